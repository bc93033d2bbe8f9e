// test_clips.c - gsf_restore_clip: clips of all sizes and lengths through restorers with limits.
#include "gsfixer.h"
#include "test.h"
#include "test_hooks.h"

enum { MOST = 160, SHOWN = 64 };

typedef struct fake { // returns its input, a little brighter with each part
    gsf_restorer restorer;
    gsf_restorer_info limits;
    int calls, counts[SHOWN];
    int32_t width, height;
    int fail_at, seen_reference;
    float first[SHOWN], last[SHOWN], depth; // per part: red of its first and of its last frame
} fake;

static gsf_result fake_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                             gsf_restorer_info* out) {
    (void)ctx, (void)frames, (void)width, (void)height;
    const uint32_t size = out->struct_size;
    *out = ((fake*)user)->limits;
    out->struct_size = size;
    return GSF_OK;
}

static gsf_result fake_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    (void)user, (void)ctx, (void)references, (void)count;
    return GSF_OK;
}

// Carries its arguments: the score is 1/8 in the left half and 0 in the right one, the depth tells the frame of the clip.
typedef struct fake_carrier { gsf_image images[7]; int32_t calls; } fake_carrier;
static gsf_result fake_carry(void* user, gsf_context* ctx, int32_t frame, int32_t slot, gsf_carried* out) {
    fake_carrier* c = (fake_carrier*)user;
    (void)ctx;
    gsf_image* const to[7] = {&out->color, &out->residual, &out->score, &out->depth, &out->angle, &out->back_color,
                              &out->back_ratio};
    for (int k = 0; k < 7; k++) *to[k] = c->images[k];
    for (int64_t i = 0; i < out->score.width * out->score.height; i++) {
        ((float*)out->score.data)[i] = i % out->score.width < out->score.width / 2 ? 0.125f : 0.0f;
        ((float*)out->depth.data)[i] = (float)(frame + 1);
        for (int k = 0; k < 3; k++) ((float*)out->color.data)[3 * i + k] = (float)k;
    }
    out->reference = slot;
    c->calls++;
    return GSF_OK;
}

// Every frame of a part is carried at the part's size.
static void check_carried(gsf_context* ctx, const fake* f, const gsf_restore_window* w) {
    gsf_carried k;
    for (int32_t i = 0; i < w->frame_count; i++) {
        if (!CHECK_OK(ctx, w->carry_fn(w->carry_user, ctx, i, 2, &k))) return;
        const float *score = (const float*)k.score.data, *depth = (const float*)k.depth.data;
        CHECK(k.reference == 2 && k.score.width == f->width && k.back_color.height == f->height);
        CHECK(score[0] == 0.125f && score[f->width - 1] == 0.0f && ((const float*)k.color.data)[5] == 2.0f);
        CHECK_NEAR(((const float*)w->color[i].data)[0], (depth[0] - 1.0f + 40.0f) / 255.0f, 1e-6); // this frame of the clip
    }
}

static gsf_result fake_restore(void* user, gsf_context* ctx, const gsf_restore_window* w) {
    fake* f = (fake*)user;
    CHECK(w->part == f->calls && w->clip == 5 && w->seed == 70u + (uint64_t)f->calls);
    if (f->calls == SHOWN) return GSF_ERROR_RESTORER;
    f->counts[f->calls] = w->frame_count;
    f->width = (int32_t)w->color[0].width;
    f->height = (int32_t)w->color[0].height;
    f->first[f->calls] = ((const float*)w->color[0].data)[0];
    f->last[f->calls] = ((const float*)w->color[w->frame_count - 1].data)[0];
    if (w->depth) f->depth = ((const float*)w->depth[0].data)[0];
    CHECK(w->struct_size == sizeof *w);
    if (w->carry_fn) check_carried(ctx, f, w);
    for (int32_t i = 0; i < w->frame_count; i++) {
        CHECK(w->color[i].width == f->width && w->out_color[i].height == f->height);
        CHECK(!w->cameras || (w->cameras[i].width == f->width && w->cameras[i].height == f->height));
        f->seen_reference += w->reference_index[i] == 3;
        const int64_t values = w->color[i].width * w->color[i].height;
        for (int64_t k = 0; k < 3 * values; k++)
            ((float*)w->out_color[i].data)[k] = ((const float*)w->color[i].data)[k] + 0.001f * (float)f->calls;
        for (int64_t k = 0; k < values; k++) ((float*)w->out_confidence[i].data)[k] = 0.5f;
    }
    return ++f->calls == f->fail_at ? gsf_fail(ctx, GSF_ERROR_RESTORER, "out of ideas") : GSF_OK;
}

static void fake_end(void* user, gsf_context* ctx) { (void)user, (void)ctx; }

static fake make_fake(void) {
    fake f;
    memset(&f, 0, sizeof f);
    f.restorer.struct_size = sizeof f.restorer;
    f.restorer.query_fn = fake_query;
    f.restorer.begin_fn = fake_begin;
    f.restorer.restore_fn = fake_restore;
    f.restorer.end_fn = fake_end;
    return f;
}

typedef struct clip {
    gsf_image color[MOST], depth[MOST], out[MOST], confidence[MOST];
    gsf_camera cameras[MOST];
    int32_t reference_index[MOST];
    gsf_restore_window window;
} clip;

static float shade(int frame) { return (float)(frame + 40) / 255.0f; }

// Frame i has a colour that identifies i; its right half is darker.
static void make_clip(gsf_context* ctx, clip* c, int frames, int width, int height) {
    memset(c, 0, sizeof *c);
    for (int i = 0; i < frames; i++) {
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 3, &c->color[i]));
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 1, &c->depth[i]));
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 3, &c->out[i]));
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 1, &c->confidence[i]));
        for (int k = 0; k < 3 * width * height; k++)
            ((float*)c->color[i].data)[k] = k / 3 % width < width / 2 ? shade(i) : 20.0f / 255.0f;
        for (int k = 0; k < width * height; k++) ((float*)c->depth[i].data)[k] = 3.25f;
        c->cameras[i].width = width;
        c->cameras[i].height = height;
        c->cameras[i].fx = c->cameras[i].fy = 10.0;
        c->reference_index[i] = i == 0 ? 3 : -1;
    }
    c->window.struct_size = sizeof c->window;
    c->window.frame_count = frames;
    c->window.color = c->color;
    c->window.depth = c->depth;
    c->window.cameras = c->cameras;
    c->window.reference_index = c->reference_index;
    c->window.out_color = c->out;
    c->window.out_confidence = c->confidence;
    c->window.seed = 70;
    c->window.clip = 5;
}

static void free_clip(gsf_context* ctx, clip* c) {
    for (int i = 0; i < MOST; i++) {
        gsf_destroy_image(ctx, &c->color[i]);
        gsf_destroy_image(ctx, &c->depth[i]);
        gsf_destroy_image(ctx, &c->out[i]);
        gsf_destroy_image(ctx, &c->confidence[i]);
    }
}

// Every frame comes back in its place, to within `frames_off` frames and the brightness that the parts added.
static void check_back(const clip* c, int parts, double frames_off) {
    for (int i = 0; i < c->window.frame_count; i++) {
        const gsf_image* out = &c->out[i];
        const float *left = (const float*)out->data, *right = left + 3 * (out->width - 1);
        const double off = (double)left[0] - (double)shade(i);
        CHECK(off > -1e-4 - frames_off / 255.0 && off < 0.001 * (parts - 1) + 1e-4 + frames_off / 255.0);
        CHECK_NEAR(right[0], 20.0 / 255.0, 0.001 * (parts - 1) + 1e-4);
        CHECK_NEAR(((const float*)c->confidence[i].data)[0], 0.5, 1e-6);
    }
}

static void test_lengths(gsf_context* ctx) {
    for (int step = 1; step <= 8; step += 7)
        for (int frames = 1; frames <= MOST; frames += frames < 60 ? 1 : 17) {
            static clip c;
            fake f = make_fake();
            f.limits.frame_count_min = step == 1 ? 49 : 9; // a fixed frame count, or a range
            f.limits.frame_count_max = f.limits.frame_count = 49;
            f.limits.frame_count_step = step;
            f.restorer.user = &f;
            make_clip(ctx, &c, frames, 8, 6);
            CHECK_OK(ctx, gsf_restore_clip(ctx, &f.restorer, &c.window));
            for (int p = 0; p < f.calls; p++) {
                CHECK(f.counts[p] <= 49 && f.counts[p] >= 9 && (f.counts[p] - 9) % 8 == 0);
                if (step == 1 || frames > 49) CHECK(f.counts[p] == 49);
            }
            if (frames <= 49)
                CHECK(f.calls == 1 && f.counts[0] >= frames && (step == 1 || f.counts[0] - frames < 8 || frames < 9));
            else CHECK(f.calls == 1 + (frames - 8 - 1) / 41);
            CHECK_NEAR(f.first[0], shade(0), 1e-6); // the parts include both ends of the clip, and overlap
            CHECK_NEAR(f.last[f.calls - 1], shade(frames - 1), 1e-6);
            for (int p = 1; p < f.calls; p++) CHECK(f.first[p] < f.last[p - 1] - 6.5f / 255.0f);
            CHECK(f.seen_reference >= 1);
            check_back(&c, f.calls, 0.0);
            free_clip(ctx, &c);
        }
}

static void test_sizes(gsf_context* ctx) {
    static const struct {
        int squash, width, height, multiple, most_width, in_width, in_height, out_width, out_height;
    } cases[] = {
        {1, 72, 48, 72, 72, 26, 48, 72, 48}, // other aspects (squashed), larger and smaller than the input
        {1, 72, 48, 72, 72, 96, 54, 72, 48},
        {1, 72, 48, 8, 0, 200, 90, 72, 48},
        {0, 0, 0, 8, 0, 61, 43, 64, 40},     // the nearest multiples
        {0, 0, 0, 0, 50, 100, 60, 50, 30},   // scaled down, aspect kept
        {0, 0, 0, 40, 40, 100, 20, 0, 0},    // square pixels required, but no allowed size has that aspect
        {0, 0, 0, 0, 0, 33, 21, 33, 21},
    };
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        static clip c;
        fake f = make_fake();
        f.limits.squash = cases[k].squash;
        f.limits.width = cases[k].width;
        f.limits.height = cases[k].height;
        f.limits.width_multiple = cases[k].multiple;
        f.limits.height_multiple = cases[k].multiple == 72 ? 48 : cases[k].multiple;
        f.limits.width_max = cases[k].most_width;
        f.limits.height_max = cases[k].multiple == 72 ? 48 : 0;
        f.restorer.user = &f;
        make_clip(ctx, &c, 3, cases[k].in_width, cases[k].in_height);
        CHECK_RESULT(ctx, gsf_restore_clip(ctx, &f.restorer, &c.window),
                     cases[k].out_width ? GSF_OK : GSF_ERROR_UNSUPPORTED);
        if (cases[k].out_width) {
            CHECK(f.calls == 1 && f.width == cases[k].out_width && f.height == cases[k].out_height && f.depth == 3.25f);
            check_back(&c, 1, 0.0);
        } else {
            CHECK(strstr(ctx->error, "square") != NULL);
        }
        free_clip(ctx, &c);
    }
}

// carry_fn is passed on: as it is, in another size, in parts. A host whose window ends before it has none.
static void test_carried(gsf_context* ctx) {
    static const int32_t channels[7] = {3, 3, 1, 1, 1, 3, 1};
    for (int way = 0; way < 4; way++) {
        static clip c;
        fake_carrier carrier = {0};
        fake f = make_fake();
        if (way >= 1) f.limits.width_multiple = f.limits.height_multiple = 16;
        if (way >= 2) f.limits.frame_count_max = f.limits.frame_count = 7;
        f.restorer.user = &f;
        make_clip(ctx, &c, 12, 30, 20);
        for (int k = 0; k < 7; k++) CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, 30, 20, channels[k], &carrier.images[k]));
        c.window.carry_fn = fake_carry;
        c.window.carry_user = &carrier;
        if (way == 3) c.window.struct_size = (uint32_t)offsetof(gsf_restore_window, carry_fn);
        CHECK_OK(ctx, gsf_restore_clip(ctx, &f.restorer, &c.window));
        CHECK(f.calls == (way < 2 ? 1 : 2) && carrier.calls == (way < 2 ? 12 : way == 2 ? 14 : 0));
        for (int k = 0; k < 7; k++) gsf_destroy_image(ctx, &carrier.images[k]);
        free_clip(ctx, &c);
    }
    gsf_restore_window window = {0};
    window.struct_size = (uint32_t)offsetof(gsf_restore_window, carry_fn) - 1;
    CHECK_RESULT(ctx, gsf_restore_clip(ctx, NULL, &window), GSF_ERROR_INVALID_ARGUMENT);
}

static void test_trouble(void) { // a failing part, and allocation failure at every call
    static clip c;
    counter count;
    gsf_context ctx;
    memset(&count, 0, sizeof count);
    test_context_zero(&ctx);
    ctx.threads = 1;
    count_memory(&ctx, &count);
    if (gsf_init_context(&ctx) != GSF_OK) exit(2);
    make_clip(&ctx, &c, 20, 12, 9);
    const size_t before = count.live;
    for (size_t k = 1;; k++) {
        fake f = make_fake();
        f.limits.frame_count_max = 9;
        f.limits.width_multiple = f.limits.height_multiple = 8;
        f.restorer.user = &f;
        f.fail_at = k == 1 ? 2 : 0;
        count.calls = 0;
        count.fail_at = k == 1 ? 0 : k - 1;
        const gsf_result result = gsf_restore_clip(&ctx, &f.restorer, &c.window);
        CHECK(count.live == before);
        if (!result) break;
        if (!CHECK(result == (k == 1 ? GSF_ERROR_RESTORER : GSF_ERROR_OUT_OF_MEMORY))) break;
    }
    count.fail_at = 0;
    free_clip(&ctx, &c);
    CHECK(count.live == 0);
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    test_lengths(&ctx);
    test_sizes(&ctx);
    test_carried(&ctx);
    test_trouble();
    return test_report();
}
