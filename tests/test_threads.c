// All parallel code on a pthread job system behind the parallel hook: 1, 2 and 3 workers give the same bytes. Built
// with ThreadSanitizer, this is also the test for data races.
#define JOB_SYSTEM_ONLY
#include "../examples/job_system.c"
#include "test.h"
#include "worker_runs.h"

enum { WIDTH = 96, HEIGHT = 72, VIEWS = 3, SPLATS = 600, POINTS = 3000 };

static void add_splats(stage_output* out, const gsf_splats* s) {
    add(out, &s->count, sizeof s->count);
    add(out, s->means, s->count * 3 * sizeof(float));
    add(out, s->log_scales, s->count * 3 * sizeof(float));
    add(out, s->quats, s->count * 4 * sizeof(float));
    add(out, s->opacity_logits, s->count * sizeof(float));
    add(out, s->sh, s->count * 3 * (size_t)gsf_splat_count_sh(s->sh_degree) * sizeof(float));
    add(out, s->ids, s->count * sizeof(uint32_t));
}

// ---- a small scene ---------------------------------------------------------------

static gsf_camera make_camera(int view) { // around the z axis, looking at a unit blob 3 in front
    const double angle = 0.25 * (view - 1), c = cos(angle), s = sin(angle);
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    const double w2c[16] = {c, 0, -s, 0, 0, 1, 0, 0, s, 0, c, 0, 0, 0, 3, 1};
    memcpy(camera.w2c, w2c, sizeof w2c);
    camera.fx = camera.fy = 90.0;
    camera.cx = WIDTH / 2.0;
    camera.cy = HEIGHT / 2.0;
    camera.width = WIDTH;
    camera.height = HEIGHT;
    return camera;
}

static void make_splats(gsf_context* ctx, uint64_t seed, gsf_splats* out) {
    CHECK_OK(ctx, gsf_splat_make(ctx, SPLATS, 1, out));
    const size_t row = 3 * (size_t)gsf_splat_count_sh(1);
    for (size_t i = 0; i < SPLATS; i++) {
        for (uint64_t a = 0; a < 3; a++) {
            out->means[3 * i + a] = (float)(1.6 * gsf_draw_uniform(seed, a, i) - 0.8);
            out->log_scales[3 * i + a] = (float)(-3.5 + gsf_draw_uniform(seed, 3 + a, i));
        }
        for (uint64_t a = 0; a < 4; a++) out->quats[4 * i + a] = (float)gsf_draw_normal(seed, 6 + a, i);
        for (uint64_t a = 0; a < row; a++)
            out->sh[row * i + a] = (float)((a < 3 ? 1.0 : 0.1) * gsf_draw_normal(seed, 10 + a, i));
        out->opacity_logits[i] = (float)gsf_draw_normal(seed, 99, i);
    }
}

static float* make_floats(size_t count, uint64_t stream) {
    float* v = (float*)malloc(count * sizeof(float));
    for (size_t i = 0; i < count; i++) v[i] = (float)gsf_draw_uniform(3, stream, i);
    return v;
}

// ---- stages ----------------------------------------------------------------------

static void run_images(gsf_context* ctx, run_output* run) {
    enum { W = 301, H = 223, W2 = 170, H2 = 97 };
    float* a = make_floats(W * H * 3, 0);
    float* b = make_floats(W * H * 3, 1);
    uint8_t* bytes = (uint8_t*)malloc(W * H * 3);
    uint8_t* small = (uint8_t*)malloc(W2 * H2 * 3);
    float* small_floats = (float*)malloc(W2 * H2 * 3 * sizeof(float));
    const gsf_image image_a = gsf_wrap_image(a, GSF_F32, W, H, 3), image_b = gsf_wrap_image(b, GSF_F32, W, H, 3);
    const gsf_image image_bytes = gsf_wrap_image(bytes, GSF_U8, W, H, 3);
    const gsf_image image_small = gsf_wrap_image(small, GSF_U8, W2, H2, 3);
    const gsf_image image_small_floats = gsf_wrap_image(small_floats, GSF_F32, W2, H2, 3);

    stage_output* out = begin_stage(run, "convert");
    CHECK_OK(ctx, gsf_convert_image(ctx, &image_a, &image_bytes));
    add(out, bytes, W * H * 3);

    out = begin_stage(run, "resize");
    const gsf_resize_filter filters[3] = {GSF_RESIZE_PIL_BILINEAR, GSF_RESIZE_PIL_BICUBIC, GSF_RESIZE_PIL_LANCZOS};
    for (int i = 0; i < 3; i++) {
        CHECK_OK(ctx, gsf_resize_image(ctx, &image_bytes, filters[i], &image_small));
        add(out, small, W2 * H2 * 3);
    }
    CHECK_OK(ctx, gsf_resize_image(ctx, &image_a, GSF_RESIZE_PIL_BILINEAR, &image_small_floats));
    add(out, small_floats, W2 * H2 * 3 * sizeof(float));

    out = begin_stage(run, "metrics");
    double value;
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &image_a, &image_b, NULL, &value));
    add(out, &value, sizeof value);
    const gsf_metric kinds[3] = {GSF_METRIC_SSIM_3DGS, GSF_METRIC_SSIM_TORCHMETRICS, GSF_METRIC_SSIM_SKIMAGE};
    for (int i = 0; i < 3; i++) {
        CHECK_OK(ctx, gsf_measure_image(ctx, kinds[i], &image_a, &image_b, NULL, &value));
        add(out, &value, sizeof value);
    }
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_DIFFERENCE, &image_a, &image_b, NULL, &value));
    add(out, &value, sizeof value);
    free(a);
    free(b);
    free(bytes);
    free(small);
    free(small_floats);
}

static void run_points(gsf_context* ctx, run_output* run) {
    double* points = (double*)malloc(POINTS * 3 * sizeof(double));
    uint8_t* colors = (uint8_t*)malloc(POINTS * 3);
    for (size_t i = 0; i < POINTS; i++)
        for (uint64_t a = 0; a < 3; a++) {
            points[3 * i + a] = gsf_draw_uniform(4, a, i) * 1.6 - 0.8;
            colors[3 * i + a] = (uint8_t)(gsf_draw_bits(4, 3 + a, i) & 255u);
        }
    const double origin[3] = {0.0, 0.0, 0.0};
    gsf_splats splats;
    stage_output* out = begin_stage(run, "splats from points");
    if (CHECK_OK(ctx, gsf_splat_make_from_points(ctx, points, colors, POINTS, NULL, 0, origin, &splats)))
        add_splats(out, &splats);
    gsf_splat_destroy(ctx, &splats);

    gsf_scene scene; // built by hand: no tracks
    memset(&scene, 0, sizeof scene);
    gsf_scene_view views[VIEWS];
    memset(views, 0, sizeof views);
    const uint32_t chosen[VIEWS] = {0, 1, 2};
    for (int v = 0; v < VIEWS; v++) views[v].camera = make_camera(v);
    scene.views = views;
    scene.view_count = VIEWS;
    scene.points = points;
    scene.colors = colors;
    scene.point_count = POINTS;
    scene.track_begin = (size_t*)calloc(POINTS + 1, sizeof(size_t));
    uint8_t* keep = (uint8_t*)calloc(POINTS, 1);
    gsf_visibility_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.method = GSF_VISIBILITY_RAYS;
    for (int z = 0; z < 2; z++) {
        desc.use_zbuffer = z;
        out = begin_stage(run, z ? "visible points, z-buffer" : "visible points, rays");
        CHECK_OK(ctx, gsf_splat_filter_points(ctx, &scene, chosen, VIEWS, &desc, keep, NULL));
        add(out, keep, POINTS);
    }
    free(keep);
    free(scene.track_begin);
    free(points);
    free(colors);
}

static void run_render(gsf_context* ctx, run_output* run) {
    gsf_splats splats;
    make_splats(ctx, 7, &splats);
    const gsf_camera camera = make_camera(0);
    float* color = make_floats(WIDTH * HEIGHT * 3, 0);
    float* depth = make_floats(WIDTH * HEIGHT, 0);
    float* alpha = make_floats(WIDTH * HEIGHT, 0);
    float* d_color = make_floats(WIDTH * HEIGHT * 3, 5);
    float* d_depth = make_floats(WIDTH * HEIGHT, 6);
    float* d_alpha = make_floats(WIDTH * HEIGHT, 7);
    gsf_render_output image;
    memset(&image, 0, sizeof image);
    image.color = gsf_wrap_image(color, GSF_F32, WIDTH, HEIGHT, 3);
    image.depth = gsf_wrap_image(depth, GSF_F32, WIDTH, HEIGHT, 1);
    image.alpha = gsf_wrap_image(alpha, GSF_F32, WIDTH, HEIGHT, 1);
    gsf_rasterizer* rasterizer = NULL;
    if (!CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &rasterizer))) return;

    stage_output* out = begin_stage(run, "render");
    CHECK_OK(ctx, gsf_splat_render(ctx, rasterizer, &splats, &camera, NULL, &image));
    add(out, color, WIDTH * HEIGHT * 3 * sizeof(float));
    add(out, depth, WIDTH * HEIGHT * sizeof(float));
    add(out, alpha, WIDTH * HEIGHT * sizeof(float));

    out = begin_stage(run, "render backward");
    float gradients[SPLATS * (3 + 3 + 4 + 1 + 12 + 2 + 2) + 3]; // one after another, as in gsf_splat_grads
    memset(gradients, 0, sizeof gradients);
    gsf_splat_grads grads;
    grads.means = gradients;
    grads.log_scales = grads.means + 3 * SPLATS;
    grads.quats = grads.log_scales + 3 * SPLATS;
    grads.opacity_logits = grads.quats + 4 * SPLATS;
    grads.sh = grads.opacity_logits + SPLATS;
    grads.means2d = grads.sh + 12 * SPLATS;
    grads.means2d_abs = grads.means2d + 2 * SPLATS;
    grads.background = grads.means2d_abs + 2 * SPLATS;
    CHECK_OK(ctx,
             gsf_splat_render_backward(ctx, rasterizer, &splats, &camera, NULL, d_color, d_depth, d_alpha, &grads));
    add(out, gradients, sizeof gradients);
    double sum = 0.0;
    for (size_t i = 0; i < sizeof gradients / sizeof gradients[0]; i++) sum += fabs((double)gradients[i]);
    CHECK(sum > 1.0); // something was compared

    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    gsf_splat_destroy(ctx, &splats);
    free(color);
    free(depth);
    free(alpha);
    free(d_color);
    free(d_depth);
    free(d_alpha);
}

// Images of splats that the trainer does not start from. The caller frees the pixels.
static float* make_views(gsf_context* ctx, gsf_train_view views[VIEWS]) {
    gsf_splats truth;
    make_splats(ctx, 8, &truth);
    memset(views, 0, VIEWS * sizeof *views);
    float* pixels = make_floats(VIEWS * WIDTH * HEIGHT * 3, 0);
    gsf_rasterizer* rasterizer = NULL;
    CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &rasterizer));
    for (int v = 0; v < VIEWS; v++) {
        views[v].camera = make_camera(v);
        views[v].image = gsf_wrap_image(pixels + (size_t)v * WIDTH * HEIGHT * 3, GSF_F32, WIDTH, HEIGHT, 3);
        gsf_render_output image;
        memset(&image, 0, sizeof image);
        image.color = views[v].image;
        CHECK_OK(ctx, gsf_splat_render(ctx, rasterizer, &truth, &views[v].camera, NULL, &image));
    }
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    gsf_splat_destroy(ctx, &truth);
    return pixels;
}

// Training with densification, pruning, an opacity reset and a restored view.
static void run_training(gsf_context* ctx, run_output* run) {
    gsf_splats start;
    make_splats(ctx, 9, &start);
    gsf_train_view views[VIEWS];
    float* pixels = make_views(ctx, views);
    float* weight = make_floats(WIDTH * HEIGHT, 1);
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 48;
    desc.seed = 11;
    desc.sh_interval = 8;
    desc.densify_from = 6;
    desc.densify_until = 40;
    desc.densify_interval = 6;
    desc.densify_grad = 1e-5f;
    desc.opacity_reset_interval = 20;
    desc.dropout = 0.1f;
    gsf_trainer* trainer = NULL;
    stage_output* out = begin_stage(run, "training");
    if (CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, views, 2, &start, &trainer))) {
        size_t most = 0;
        for (int i = 0; i < desc.iterations; i++) {
            gsf_train_stats stats;
            memset(&stats, 0, sizeof stats);
            if (i == 24) { // the third view is added as a restored view
                views[2].weight = gsf_wrap_image(weight, GSF_F32, WIDTH, HEIGHT, 1);
                CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, views + 2, 1));
                gsf_splat_set_restored_weight(trainer, 0.5f);
            }
            if (!CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, &stats))) break;
            add(out, &stats.loss, sizeof stats.loss);
            if (stats.splats > most) most = stats.splats;
        }
        CHECK(most > SPLATS); // it did densify
        gsf_splats trained;
        if (CHECK_OK(ctx, gsf_splat_copy_trained(ctx, trainer, &trained))) add_splats(out, &trained);
        gsf_splat_destroy(ctx, &trained);
        out = begin_stage(run, "checkpoint");
        gsf_buffer chunks;
        memset(&chunks, 0, sizeof chunks);
        gsf_splat_format_trainer(ctx, trainer, &chunks);
        CHECK(!chunks.failed && chunks.size > 0);
        add(out, chunks.data, chunks.size);
        gsf_destroy_buffer(ctx, &chunks);
        gsf_splat_destroy_trainer(ctx, trainer);
    }
    gsf_splat_destroy(ctx, &start);
    free(pixels);
    free(weight);
}

// The whole repair loop with the warp restorer: one round, after half of the training.
static void run_repair(gsf_context* ctx, run_output* run) {
    gsf_splats start;
    make_splats(ctx, 9, &start);
    gsf_train_view views[VIEWS];
    float* pixels = make_views(ctx, views);
    gsf_restorer warp;
    gsf_fixer* fixer = NULL;
    gsf_fix_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.train.iterations = 20;
    desc.train.seed = 3;
    desc.rounds = 1;
    desc.first_round = 10;
    desc.windows = 2;
    desc.window_frames = 5;
    stage_output* out = begin_stage(run, "repair");
    CHECK_OK(ctx, gsf_splat_make_warp(ctx, &warp));
    if (CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, views, VIEWS, &start, &warp, &fixer))) {
        gsf_fix_stats stats;
        memset(&stats, 0, sizeof stats);
        int restored = 0;
        while (stats.stage != GSF_FIX_DONE) {
            if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) break;
            for (int32_t f = 0; stats.stage == GSF_FIX_RESTORE && stats.restored && f < stats.frame_count; f++) {
                const gsf_image* frame = &stats.restored[f];
                add(out, frame->data, (size_t)(frame->stride_y * frame->height));
                restored++;
            }
        }
        CHECK(restored > 0);
        add_splats(out, gsf_splat_get_trained(gsf_splat_get_trainer(fixer)));
        gsf_splat_destroy_fixer(ctx, fixer);
    }
    gsf_destroy_restorer(ctx, &warp);
    gsf_splat_destroy(ctx, &start);
    free(pixels);
}

static void run_all(gsf_context* ctx, run_output* run) {
    run_images(ctx, run);
    run_points(ctx, run);
    run_render(ctx, run);
    run_training(ctx, run);
    run_repair(ctx, run);
}

int main(void) {
    compare_runs(run_all);
    return test_report();
}
