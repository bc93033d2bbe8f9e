// fuzz_checkpoint.c - checkpoints of the repair loop. Build line: fuzz.h. Input: a byte below 128, the number of steps
// after which a small loop is saved, followed by patches to that checkpoint (fuzz_patch_chunks); or a byte from 128 on,
// followed by a whole file. Checksums are corrected. A refused checkpoint leaves the loop unchanged; an accepted one is
// written back byte-identically, and the loop continues from it.
#include "fuzz.h"

enum { SIDE = 8, VIEWS = 3, SPLATS = 5, STEPS = 16 };

static gsf_result query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                        gsf_restorer_info* limits) {
    (void)user, (void)ctx, (void)frames, (void)width, (void)height, (void)limits;
    return GSF_OK; // takes everything
}
static gsf_result begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    (void)user, (void)ctx, (void)references, (void)count;
    return GSF_OK;
}
static gsf_result restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    (void)user, (void)ctx;
    for (int32_t i = 0; i < window->frame_count; i++) {
        const gsf_image *color = &window->out_color[i], *confidence = &window->out_confidence[i];
        memset(color->data, 0, (size_t)(color->stride_y * color->height));
        memset(confidence->data, 0, (size_t)(confidence->stride_y * confidence->height));
    }
    return GSF_OK;
}
static void end(void* user, gsf_context* ctx) { (void)user, (void)ctx; }

static gsf_restorer black; // paints everything black

static gsf_fixer* make_loop(gsf_context* ctx) {
    gsf_train_view views[VIEWS];
    gsf_fix_desc desc;
    gsf_splats start;
    gsf_fixer* loop;
    static uint8_t photo[SIDE * SIDE * 3];
    memset(&desc, 0, sizeof desc);
    memset(views, 0, sizeof views);
    for (size_t i = 0; i < sizeof photo; i++) photo[i] = (uint8_t)(37 * i);
    for (int v = 0; v < VIEWS; v++) {
        gsf_camera* camera = &views[v].camera;
        const double angle = 0.2 * (v - 1);
        camera->w2c[0] = camera->w2c[10] = cos(angle);
        camera->w2c[8] = sin(angle), camera->w2c[2] = -sin(angle);
        camera->w2c[5] = camera->w2c[15] = 1.0, camera->w2c[14] = 4.0;
        camera->fx = camera->fy = 1.2 * SIDE;
        camera->cx = camera->cy = 0.5 * SIDE;
        camera->width = camera->height = SIDE;
        views[v].image = gsf_wrap_image(photo, GSF_U8, SIDE, SIDE, 3);
    }
    FUZZ_CHECK(gsf_splat_make(ctx, SPLATS, 1, &start) == GSF_OK);
    for (size_t i = 0; i < SPLATS; i++) {
        start.means[3 * i] = 0.3f * (float)i - 0.6f;
        start.quats[4 * i] = 1.0f;
        start.log_scales[3 * i] = start.log_scales[3 * i + 1] = start.log_scales[3 * i + 2] = -1.0f;
    }
    desc.train.iterations = 8;
    desc.train.densify_from = 2;
    desc.train.densify_interval = 3;
    desc.rounds = 1;
    desc.first_round = 4;
    desc.windows = 2;
    desc.window_frames = 3;
    black.struct_size = sizeof black;
    black.query_fn = query, black.begin_fn = begin, black.restore_fn = restore, black.end_fn = end;
    FUZZ_CHECK(gsf_splat_make_fixer(ctx, &desc, views, VIEWS, &start, &black, &loop) == GSF_OK);
    gsf_splat_destroy(ctx, &start);
    return loop;
}

static void run(gsf_context* ctx, gsf_fixer* loop, int steps) {
    gsf_fix_stats now;
    memset(&now, 0, sizeof now);
    for (int i = 0; i < steps && now.stage != GSF_FIX_DONE; i++)
        if (gsf_splat_step_fixer(ctx, loop, &now) != GSF_OK) FUZZ_CHECK(ctx->error[0] != 0);
}

static gsf_buffer save(gsf_context* ctx, const gsf_fixer* loop) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_splat_format_fixer(ctx, loop, &text);
    gsf_append_last_chunk(ctx, &text);
    FUZZ_CHECK(!text.failed);
    return text;
}

// The checkpoint after `steps` steps, made once.
static const gsf_buffer* saved_at(gsf_context* ctx, size_t steps) {
    static gsf_buffer all[STEPS];
    if (!all[steps].data) {
        gsf_fixer* loop = make_loop(ctx);
        run(ctx, loop, (int)steps);
        gsf_buffer text = save(ctx, loop);
        all[steps] = text;
        all[steps].data = (char*)malloc(text.size);
        FUZZ_CHECK(all[steps].data);
        memcpy(all[steps].data, text.data, text.size);
        gsf_destroy_buffer(ctx, &text);
        gsf_splat_destroy_fixer(ctx, loop);
    }
    return &all[steps];
}

static gsf_buffer make_file(gsf_context* ctx, const uint8_t* data, size_t size) {
    gsf_buffer file;
    memset(&file, 0, sizeof file);
    if (data[0] >= 128) {
        fuzz_sum_chunks(ctx, data + 1, size - 1, &file);
    } else {
        const gsf_buffer* base = saved_at(ctx, data[0] % STEPS);
        fuzz_patch_chunks(ctx, (const uint8_t*)base->data, base->size, data + 1, size - 1, &file);
    }
    return file;
}

static void check_same(const gsf_buffer* a, const gsf_buffer* b) {
    FUZZ_CHECK(a->size == b->size && memcmp(a->data, b->data, a->size) == 0);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    if (size == 0) return 0;
    gsf_context ctx = fuzz_context(size);
    fuzz_limit += (size_t)4 << 20; // for the loop itself
    gsf_buffer file = make_file(&ctx, data, size);
    gsf_fixer* loop = make_loop(&ctx);
    gsf_buffer before = save(&ctx, loop);
    const gsf_result result = gsf_splat_parse_fixer(&ctx, loop, "fuzz", file.data, file.size);
    gsf_buffer after = save(&ctx, loop);
    if (result != GSF_OK) {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED);
        fuzz_check_error(&ctx, "fuzz:");
        check_same(&before, &after);
        FUZZ_CHECK(size > 1 || data[0] >= 128); // without patches, the checkpoint must be accepted
    } else {
        FUZZ_CHECK(gsf_splat_parse_fixer(&ctx, loop, "again", after.data, after.size) == GSF_OK);
        gsf_buffer again = save(&ctx, loop);
        check_same(&after, &again);
        gsf_destroy_buffer(&ctx, &again);
        run(&ctx, loop, STEPS);
    }
    gsf_destroy_buffer(&ctx, &after);
    gsf_destroy_buffer(&ctx, &before);
    gsf_destroy_buffer(&ctx, &file);
    gsf_splat_destroy_fixer(&ctx, loop);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
