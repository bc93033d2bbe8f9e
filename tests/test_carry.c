// test_carry.c - what photos show in other views (carry_fn of a restorer's windows) against a ray-traced scene: reach and
// colours, exposures, masks; the same bits for any number of workers and after a checkpoint; failing allocations.
#define _XOPEN_SOURCE 700 // mkdir
#define _POSIX_C_SOURCE 200809L
#include "gsfixer_splat.h"

#include "test.h"
#define MAKE_SCENE_NO_MAIN
#include "../examples/make_scene.c"
#include "test_hooks.h"

enum { WIDTH = 88, HEIGHT = 66, PIXELS = WIDTH * HEIGHT, VIEWS = 4, FRAMES = 3, SLOTS = 3, MASKED = 1 };
enum { POINTS = VIEWS * PIXELS / 9 + 99 };

typedef struct shots { // photos of a made scene, and where its surfaces are
    world s;
    gsf_train_view views[VIEWS];
    uint8_t pixels[VIEWS][3 * PIXELS];
    float depth[VIEWS][PIXELS], normal[3 * PIXELS];
    gsf_splats start;
} shots;

static void take(gsf_context* ctx, const world* s, const gsf_camera* camera, uint8_t* pixels, float* depth, float* normal) {
    photo_job job = {s, *camera, 0, pixels, depth, normal, 1.0f};
    ctx->parallel.for_fn(ctx->parallel.user, HEIGHT, photo_row, &job);
}

static void locate(const gsf_camera* camera, double x, double y, double z, double point[3]) {
    double c2w[16];
    gsf_get_camera_c2w(camera, c2w);
    const double a = (x - camera->cx) / camera->fx * z, b = (y - camera->cy) / camera->fy * z;
    for (int k = 0; k < 3; k++) point[k] = c2w[k] * a + c2w[4 + k] * b + c2w[8 + k] * z + c2w[12 + k];
}

// Splats at the surface points of every third pixel in both directions.
static int make_start(gsf_context* ctx, shots* c) {
    static double points[3 * POINTS];
    static uint8_t colors[3 * POINTS];
    size_t n = 0;
    for (int v = 0; v < VIEWS; v++)
        for (int y = 1; y < HEIGHT; y += 3)
            for (int x = 1; x < WIDTH; x += 3) {
                const int at = y * WIDTH + x;
                if (!(c->depth[v][at] > 0.0f)) continue; // sky
                locate(&c->views[v].camera, x + 0.5, y + 0.5, (double)c->depth[v][at], points + 3 * n);
                memcpy(colors + 3 * n++, c->pixels[v] + 3 * at, 3);
            }
    return CHECK_OK(ctx, gsf_splat_make_from_points(ctx, points, colors, n, NULL, 0, NULL, &c->start));
}

static gsf_camera capture_camera(shots* c, int index) { // of 24 around the courtyard; the photos are 6, 7, ...
    make_scene_options o = make_scene_defaults;
    o.views = 24;
    o.width = WIDTH;
    o.height = HEIGHT;
    return camera_of(&c->s, &o, index);
}

// The courtyard.
static int make_capture(gsf_context* ctx, shots* c) {
    make_scene_options o = make_scene_defaults;
    memset(c, 0, sizeof *c);
    o.views = 24;
    o.width = WIDTH;
    o.height = HEIGHT;
    if (!CHECK(start_world(ctx, &c->s, &o))) return 0;
    for (int v = 0; v < VIEWS; v++) {
        gsf_train_view* view = c->views + v;
        view->camera = capture_camera(c, 6 + v);
        take(ctx, &c->s, &view->camera, c->pixels[v], c->depth[v], c->normal);
        view->image = gsf_wrap_image(c->pixels[v], GSF_U8, WIDTH, HEIGHT, 3);
    }
    return make_start(ctx, c);
}

static void drop_capture(gsf_context* ctx, shots* c) {
    gsf_splat_destroy(ctx, &c->start);
    end_world(&c->s);
}

// ---- a restorer that looks at what is carried ----------------------------------

typedef struct probe {
    gsf_restorer restorer;
    const shots* c;
    int judges;              // compare with the truth
    float add;               // to the colours of its frames
    int32_t photos;
    uint64_t digest;         // of all that was carried
    int windows;
    // counts of pixels, over all frames and references: that the reference truly sees; of these, carried and verified; of the
    // carried, of nearly the right colour, at nearly the right depth
    double sees, carried, verified, right, right_verified, right_depth;
    double log_ratio[VIEWS], ratios[VIEWS]; // of verified brightness to the truth, per reference
    uint8_t hides[PIXELS];   // pixels of photo MASKED that its mask leaves out
    double from_hidden;      // carried pixels that come from there
} probe;

static gsf_result probe_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                              gsf_restorer_info* out) {
    (void)user, (void)ctx, (void)frames, (void)width, (void)height;
    if (out->struct_size >= sizeof *out) out->needs_carried = SLOTS;
    return GSF_OK;
}
static gsf_result probe_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    (void)ctx, (void)references;
    CHECK(count == ((const probe*)user)->photos);
    return GSF_OK;
}
static void probe_end(void* user, gsf_context* ctx) { (void)user, (void)ctx; }

static void digest(probe* p, const gsf_image* image) {
    const unsigned char* bytes = (const unsigned char*)image->data;
    for (int64_t i = 0; i < image->width * image->height * image->channels * 4; i++)
        p->digest = (p->digest ^ bytes[i]) * 1099511628211u;
}

// The reference's pixel that shows the point; -1 if it is hidden or outside.
static int seen_at(const shots* c, int reference, const double point[3], float tolerance) {
    double u, v, z;
    if (!gsf_project_point(&c->views[reference].camera, point, &u, &v, &z)) return -1;
    if (!(u >= 0.0 && v >= 0.0 && u < WIDTH && v < HEIGHT)) return -1;
    const int at = (int)v * WIDTH + (int)u;
    const float depth = c->depth[reference][at];
    return depth > 0.0f && fabs(z / (double)depth - 1.0) < (double)tolerance ? at : -1;
}

static void judge(probe* p, const gsf_camera* camera, const gsf_carried* k, const uint8_t* truth, const float* depth) {
    const float *color = (const float*)k->color.data, *score = (const float*)k->score.data;
    const float *shown = (const float*)k->depth.data, *angle = (const float*)k->angle.data;
    for (int at = 0; at < PIXELS; at++) {
        double point[3], off = 0.0, mean[2] = {0.0, 0.0};
        const double x = at % WIDTH + 0.5, y = at / WIDTH + 0.5;
        CHECK(score[at] >= 0.0f && score[at] <= 1.0f && angle[at] >= 0.0f);
        if (score[at] == 0.0f) CHECK(shown[at] == 0.0f && color[3 * at] == 0.0f);
        if (score[at] > 0.0f && k->reference == MASKED) {
            locate(camera, x, y, (double)shown[at], point);
            double u, v, z;
            if (gsf_project_point(&p->c->views[MASKED].camera, point, &u, &v, &z) && u >= 1 && v >= 1 && u < WIDTH - 1 &&
                v < HEIGHT - 1)
                p->from_hidden += p->hides[(int)v * WIDTH + (int)u] & p->hides[((int)v - 1) * WIDTH + (int)u - 1] &
                                  p->hides[((int)v + 1) * WIDTH + (int)u + 1];
        }
        if (!(depth[at] > 0.0f)) continue;
        locate(camera, x, y, (double)depth[at], point);
        const int sees = seen_at(p->c, k->reference, point, 0.02f) >= 0;
        p->sees += sees;
        for (int i = 0; i < 3; i++) {
            off = fmax(off, fabs((double)color[3 * at + i] - truth[3 * at + i] / 255.0));
            mean[0] += (double)color[3 * at + i];
            mean[1] += truth[3 * at + i] / 255.0;
        }
        if (score[at] == 0.0f || !sees) continue; // what another surface hides from the reference is no fault of its own
        p->carried += 1.0;
        p->right += off < 0.1;
        p->right_depth += fabs((double)(shown[at] / depth[at]) - 1.0) < 0.05;
        if (score[at] < 0.5f) continue;
        p->verified += 1.0;
        p->right_verified += off < 0.1;
        if (mean[1] < 0.3 || mean[1] > 2.4) continue;
        p->log_ratio[k->reference] += log(mean[0] / mean[1]);
        p->ratios[k->reference] += 1.0;
    }
}

static gsf_result probe_restore(void* user, gsf_context* ctx, const gsf_restore_window* w) {
    static uint8_t truth[3 * PIXELS];
    static float depth[PIXELS], normal[3 * PIXELS];
    probe* p = (probe*)user;
    if (!CHECK(w->struct_size >= sizeof *w && w->carry_fn)) return GSF_ERROR_INVALID_ARGUMENT;
    for (int32_t f = 0; f < w->frame_count; f++) {
        const gsf_camera* camera = w->cameras + f;
        if (p->judges) take(ctx, &p->c->s, camera, truth, depth, normal);
        for (int32_t slot = 0; slot < SLOTS; slot++) {
            gsf_carried k;
            const gsf_result result = w->carry_fn(w->carry_user, ctx, f, slot, &k);
            if (result != GSF_OK) return result;
            const gsf_image* images[] = {&k.color, &k.residual, &k.score, &k.depth, &k.angle, &k.back_color, &k.back_ratio};
            for (int i = 0; i < 7; i++) {
                CHECK(images[i]->width == camera->width && images[i]->height == camera->height &&
                      images[i]->dtype == GSF_F32 && images[i]->channels == (i < 2 || i == 5 ? 3 : 1));
                digest(p, images[i]);
            }
            CHECK(k.reference >= 0 && k.reference < p->photos);
            if (p->judges) judge(p, camera, &k, truth, depth);
        }
        gsf_carried none;
        CHECK_RESULT(ctx, w->carry_fn(w->carry_user, ctx, f, SLOTS, &none), GSF_ERROR_INVALID_ARGUMENT);
        CHECK_RESULT(ctx, w->carry_fn(w->carry_user, ctx, w->frame_count, 0, &none), GSF_ERROR_INVALID_ARGUMENT);
        CHECK_OK(ctx, gsf_convert_image(ctx, w->color + f, w->out_color + f));
        for (int i = 0; i < 3 * camera->width * camera->height; i++) ((float*)w->out_color[f].data)[i] += p->add;
        memset(w->out_confidence[f].data, 0, (size_t)(camera->width * camera->height) * sizeof(float));
    }
    p->windows++;
    return GSF_OK;
}

static void probe_init(probe* p, const shots* c, int judges) {
    const gsf_restorer restorer = {sizeof restorer, "probe", p, probe_query, probe_begin, probe_restore, probe_end, NULL};
    memset(p, 0, sizeof *p);
    p->restorer = restorer;
    p->c = c;
    p->judges = judges;
    p->photos = VIEWS;
    p->digest = 14695981039346656037u;
}

static gsf_fixer* make_fixer(gsf_context* ctx, const shots* c, const probe* p, float auto_exposure) {
    gsf_fix_desc desc = {0};
    gsf_fixer* fixer = NULL;
    desc.train.iterations = 8;
    desc.rounds = 2;
    desc.first_round = 3;
    desc.last_round = 6;
    desc.windows = 1;
    desc.window_frames = FRAMES;
    desc.auto_exposure = auto_exposure;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, c->views, VIEWS, &c->start, &p->restorer, &fixer));
    return fixer;
}

static int finish(gsf_context* ctx, gsf_fixer* fixer) {
    gsf_fix_stats stats = {0};
    while (stats.stage != GSF_FIX_DONE)
        if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) return 0;
    return 1;
}

static void run(gsf_context* ctx, const shots* c, probe* p) {
    gsf_fixer* fixer = make_fixer(ctx, c, p, 0.0f);
    if (fixer) finish(ctx, fixer);
    gsf_splat_destroy_fixer(ctx, fixer);
    CHECK(p->windows == 2);
}

// ---- tests ---------------------------------------------------------------------

static void test_truth(gsf_context* ctx, const shots* c, probe* p) {
    probe_init(p, c, 1);
    run(ctx, c, p);
    const double all = p->carried;
    printf("seen %.0f pixels, carried %.3f; right colour %.3f, right depth %.3f; verified %.3f of the carried, right %.3f\n",
           p->sees, p->carried / p->sees, p->right / all, p->right_depth / all, p->verified / all,
           p->right_verified / p->verified);
    CHECK(p->carried > 0.68 * p->sees);
    CHECK(p->right > 0.85 * all && p->right_depth > 0.6 * all); // 5 % of the depth are a fifth of a pixel between neighbours
    CHECK(p->verified > 0.65 * all && p->right_verified > 0.87 * p->verified);
}

// Photos of other exposures are carried as bright as each other.
static void test_exposure(gsf_context* ctx, shots* c) {
    static const double stops[VIEWS] = {1.0, 0.8, 1.1, 0.9};
    static uint8_t kept[VIEWS][3 * PIXELS];
    static probe p;
    double lo = INFINITY, hi = -INFINITY;
    int compared = 0;
    memcpy(kept, c->pixels, sizeof kept);
    for (int v = 0; v < VIEWS; v++)
        for (int i = 0; i < 3 * PIXELS; i++) c->pixels[v][i] = (uint8_t)fmin(255.0, c->pixels[v][i] * stops[v] + 0.5);
    probe_init(&p, c, 1);
    run(ctx, c, &p);
    for (int v = 0; v < VIEWS; v++) {
        if (p.ratios[v] < 1000.0) continue; // few frames are near it
        compared++;
        const double mean = p.log_ratio[v] / p.ratios[v];
        printf("photo %d, exposed by %.2f: carried as bright as %.3f\n", v, stops[v], exp(mean));
        lo = fmin(lo, mean);
        hi = fmax(hi, mean);
    }
    // the largest step is log(1.1 / 0.8) = 0.32; the mean exposure is 0.94
    CHECK(compared >= 3 && hi - lo < 0.05 && lo > log(0.9) && hi < log(1.02));
    memcpy(c->pixels, kept, sizeof kept);
}

static double mean_of(const gsf_image* image) {
    double sum = 0.0;
    for (int i = 0; i < 3 * PIXELS; i++)
        sum += image->dtype == GSF_U8 ? ((const uint8_t*)image->data)[i] / 255.0 : (double)((const float*)image->data)[i];
    return sum / (3 * PIXELS);
}

// Mean colours of final frames before the first photo and behind the last one, which are darker and brighter than these.
static void filter_frames(gsf_context* ctx, shots* c, float auto_exposure, double means[2]) {
    static float color[2][3 * PIXELS], confidence[2][PIXELS];
    static probe p;
    const gsf_camera cameras[2] = {capture_camera(c, 3), capture_camera(c, 12)};
    gsf_image colors[2], confidences[2];
    for (int i = 0; i < 2; i++) {
        colors[i] = gsf_wrap_image(color[i], GSF_F32, WIDTH, HEIGHT, 3);
        confidences[i] = gsf_wrap_image(confidence[i], GSF_F32, WIDTH, HEIGHT, 1);
    }
    for (size_t i = 0; i < c->start.count; i++) {
        for (int k = 0; k < 3; k++) c->start.log_scales[3 * i + k] += 0.4f; // without holes
        c->start.opacity_logits[i] = 5.0f;
    }
    probe_init(&p, c, 0);
    gsf_fixer* fixer = make_fixer(ctx, c, &p, auto_exposure);
    if (fixer && finish(ctx, fixer))
        CHECK_OK(ctx, gsf_splat_restore_views(ctx, &fixer, 1, cameras, 2, colors, confidences));
    for (int i = 0; i < 2; i++) means[i] = mean_of(colors + i);
    gsf_splat_destroy_fixer(ctx, fixer);
    gsf_splat_destroy(ctx, &c->start);
    make_start(ctx, c);
}

// Photos of one exposure leave the filter's frames as they are. Such as an automatic exposure made equally bright have it
// expose the darker frame more, and the brighter one less.
static void test_metering(gsf_context* ctx, shots* c) {
    static uint8_t kept[VIEWS][3 * PIXELS];
    double plain[2], exposed[2], half[2];
    memcpy(kept, c->pixels, sizeof kept);
    filter_frames(ctx, c, -1.0f, plain);
    filter_frames(ctx, c, 0.0f, exposed);
    printf("frames from photos of one exposure: %.3f, %.3f -> %.3f, %.3f\n", plain[0], plain[1], exposed[0], exposed[1]);
    CHECK(fabs(exposed[0] - plain[0]) < 0.005 && fabs(exposed[1] - plain[1]) < 0.005);
    for (int v = 0; v < VIEWS; v++) {
        const double exposure = 0.5 / mean_of(&c->views[v].image);
        for (int i = 0; i < 3 * PIXELS; i++) c->pixels[v][i] = (uint8_t)fmin(255.0, c->pixels[v][i] * exposure + 0.5);
    }
    gsf_splat_destroy(ctx, &c->start);
    make_start(ctx, c);
    filter_frames(ctx, c, -1.0f, plain);
    filter_frames(ctx, c, 0.0f, exposed);
    filter_frames(ctx, c, 0.5f, half);
    printf("from photos of mean 0.5: %.3f, %.3f -> %.3f, %.3f\n", plain[0], plain[1], exposed[0], exposed[1]);
    CHECK(exposed[0] > 1.02 * plain[0] && exposed[1] < 0.98 * plain[1]);
    for (int i = 0; i < 2; i++) CHECK(fabs(half[i] * half[i] / (plain[i] * exposed[i]) - 1.0) < 0.002);
    memcpy(c->pixels, kept, sizeof kept);
    gsf_splat_destroy(ctx, &c->start);
    make_start(ctx, c);
}

// The final frame at a camera, of a fixer or of copies: the render and what the restorer adds to it, as far as the splats are
// opaque if `by_opacity` is set.
static void filter_frame(gsf_context* ctx, gsf_fixer* const* fixers, size_t count, const gsf_camera* camera, float add,
                         int by_opacity) {
    static float color[3 * PIXELS], confidence[PIXELS], render[3 * PIXELS], alpha[PIXELS];
    gsf_image frame = gsf_wrap_image(color, GSF_F32, WIDTH, HEIGHT, 3);
    gsf_image sure = gsf_wrap_image(confidence, GSF_F32, WIDTH, HEIGHT, 1);
    gsf_render_output out;
    CHECK_OK(ctx, gsf_splat_restore_views(ctx, fixers, count, camera, 1, &frame, &sure));
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(render, GSF_F32, WIDTH, HEIGHT, 3);
    out.alpha = gsf_wrap_image(alpha, GSF_F32, WIDTH, HEIGHT, 1);
    CHECK_OK(ctx, gsf_splat_render_trainer(ctx, gsf_splat_get_trainer(fixers[0]), camera, &out));
    int thin = 0, opaque = 0;
    for (int i = 0; i < PIXELS; i++) {
        thin += alpha[i] < 0.25f;
        opaque += alpha[i] > 0.75f;
        for (int k = 3 * i; k < 3 * i + 3; k++) {
            const double expected = (double)(render[k] + (by_opacity ? alpha[i] : 1.0f) * add);
            CHECK_NEAR((double)color[k], by_opacity ? fmin(expected, 1.0) : expected, 1e-6);
        }
    }
    CHECK(thin > PIXELS / 10 && opaque > PIXELS / 10);
}

// A final frame of few photos changes as far as the splats are opaque; that of copies or of more photos changes everywhere.
static void test_opacity(gsf_context* ctx, shots* c) {
    static probe p;
    const gsf_camera camera = capture_camera(c, 12); // half of it nobody took
    gsf_train_view twice[2 * VIEWS];
    probe_init(&p, c, 0);
    p.add = 0.125f;
    gsf_fixer* fixer = make_fixer(ctx, c, &p, -1.0f);
    if (!fixer || !finish(ctx, fixer)) return;
    gsf_fixer* const copies[2] = {fixer, fixer};
    filter_frame(ctx, copies, 1, &camera, p.add, 1);
    filter_frame(ctx, copies, 2, &camera, p.add, 0);
    gsf_fix_desc desc = gsf_splat_get_fixer_desc(fixer);
    gsf_splat_destroy_fixer(ctx, fixer);
    for (int i = 0; i < 2 * VIEWS; i++) twice[i] = c->views[i % VIEWS];
    p.photos = 2 * VIEWS;
    desc.auto_exposure = -1.0f;
    desc.path = &camera; // cameras in pairs have none
    desc.path_count = 1;
    if (!CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, twice, 2 * VIEWS, &c->start, &p.restorer, &fixer))) return;
    filter_frame(ctx, &fixer, 1, &camera, p.add, 0);
    gsf_splat_destroy_fixer(ctx, fixer);
}

static void test_mask(gsf_context* ctx, shots* c) {
    static uint8_t weight[PIXELS];
    static probe p, open;
    for (int at = 0; at < PIXELS; at++) weight[at] = at % WIDTH < WIDTH / 2 ? 0 : 255;
    probe_init(&open, c, 1);
    for (int at = 0; at < PIXELS; at++) open.hides[at] = weight[at] == 0;
    p = open;
    p.restorer.user = &p;
    open.restorer.user = &open;
    run(ctx, c, &open);
    c->views[MASKED].weight = gsf_wrap_image(weight, GSF_U8, WIDTH, HEIGHT, 1);
    run(ctx, c, &p);
    memset(&c->views[MASKED].weight, 0, sizeof c->views[MASKED].weight);
    printf("from the masked half: %.0f pixels, without the mask %.0f\n", p.from_hidden, open.from_hidden);
    CHECK(p.from_hidden == 0.0 && open.from_hidden > 1000.0);
}

// With other workers, and with a new fixer after every step, which continues from a checkpoint.
static void test_same_bits(gsf_context* ctx, const shots* c, uint64_t wanted) {
    static probe p;
    gsf_context other;
    test_context_zero(&other);
    work_backwards(&other);
    if (!CHECK_OK(&other, gsf_init_context(&other))) return;
    probe_init(&p, c, 0);
    run(&other, c, &p);
    CHECK(p.digest == wanted);
    probe_init(&p, c, 0);
    gsf_buffer chunks = {0};
    gsf_fix_stats stats = {0};
    gsf_fixer* fixer = make_fixer(ctx, c, &p, 0.0f);
    while (stats.stage != GSF_FIX_DONE && CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) {
        chunks.size = 0;
        gsf_splat_format_fixer(ctx, fixer, &chunks);
        gsf_append_last_chunk(ctx, &chunks);
        gsf_splat_destroy_fixer(ctx, fixer);
        fixer = make_fixer(ctx, c, &p, 0.0f);
        if (!CHECK_OK(ctx, gsf_splat_parse_fixer(ctx, fixer, "checkpoint", chunks.data, chunks.size))) break;
    }
    gsf_splat_destroy_fixer(ctx, fixer);
    gsf_destroy_buffer(ctx, &chunks);
    CHECK(p.windows == 2 && p.digest == wanted);
}

// The middle of every photo, since what follows repeats a window a hundred times.
static void crop(const shots* c, shots* out) {
    enum { W = 64, H = 48, LEFT = (WIDTH - W) / 2, TOP = (HEIGHT - H) / 2 };
    for (int v = 0; v < VIEWS; v++) {
        gsf_train_view* view = out->views + v;
        *view = c->views[v];
        view->camera.width = W, view->camera.height = H;
        view->camera.cx -= LEFT, view->camera.cy -= TOP;
        view->image = gsf_wrap_image(out->pixels[v], GSF_U8, W, H, 3);
        for (size_t y = 0; y < H; y++)
            memcpy(out->pixels[v] + 3 * W * y, c->pixels[v] + 3 * (WIDTH * (y + TOP) + LEFT), 3 * W);
    }
    out->start = c->start; // stays the other's
}

// Every allocation of the first window fails in turn; the step is repeated and carries the same. Afterwards nothing is left.
static void test_failing(const shots* whole_photos) {
    static shots middle;
    static probe p, whole;
    const shots* c = &middle;
    gsf_context ctx;
    counter memory;
    gsf_fix_stats stats = {0};
    memset(&memory, 0, sizeof memory);
    test_context_zero(&ctx);
    count_memory(&ctx, &memory);
    ctx.threads = 1;
    if (!CHECK_OK(&ctx, gsf_init_context(&ctx))) return;
    crop(whole_photos, &middle);
    probe_init(&p, c, 0);
    probe_init(&whole, c, 0);
    gsf_fixer *fixer = make_fixer(&ctx, c, &p, 0.0f), *same = make_fixer(&ctx, c, &whole, 0.0f);
    for (int i = 0; i < 2; i++)
        for (stats.stage = GSF_FIX_TRAIN; stats.stage != GSF_FIX_PLAN;)
            if (!CHECK_OK(&ctx, gsf_splat_step_fixer(&ctx, i ? same : fixer, &stats))) return;
    CHECK_OK(&ctx, gsf_splat_step_fixer(&ctx, same, &stats));
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    size_t failures = 0;
    for (; result == GSF_ERROR_OUT_OF_MEMORY && failures < 1000; failures++) {
        p.digest = 14695981039346656037u;
        memory.fail_at = memory.calls + 1 + failures;
        result = gsf_splat_step_fixer(&ctx, fixer, &stats);
        memory.fail_at = 0;
    }
    printf("%zu allocations failed\n", failures - 1);
    CHECK(result == GSF_OK && failures > 40 && p.digest == whole.digest);
    gsf_splat_destroy_fixer(&ctx, fixer);
    gsf_splat_destroy_fixer(&ctx, same);
    CHECK(memory.live == 0);
}

int main(void) {
    static shots c;
    static probe p;
    gsf_context ctx;
    (void)make_scene; // which would write it into a folder
    test_context_init(&ctx);
    if (make_capture(&ctx, &c)) {
        test_truth(&ctx, &c, &p);
        test_same_bits(&ctx, &c, p.digest);
        test_exposure(&ctx, &c);
        test_metering(&ctx, &c);
        test_opacity(&ctx, &c);
        test_mask(&ctx, &c);
        test_failing(&c);
    }
    drop_capture(&ctx, &c);
    return test_report();
}
