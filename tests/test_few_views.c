// test_few_views.c - the path of gsfix fix from photos to splats: choice of the initial points, and the loop's
// settings.
#include "gsfixer_splat.h"
#include "test.h"
#include "test_hooks.h"

enum { VIEWS = 7, POINTS = 300, WIDTH = 64, HEIGHT = 48 };

typedef struct host { // a scene that the host built in memory, without a loader
    gsf_scene scene;
    gsf_scene_view views[VIEWS];
    double points[3 * POINTS];
    uint8_t colors[3 * POINTS], pixels[VIEWS][3 * WIDTH * HEIGHT];
    size_t track_begin[POINTS + 1];
    uint32_t track_views[VIEWS * POINTS];
} host;

// A textured wall at z = 4 with a row of cameras in front of it. Every third point has no track; the others have a track
// of three neighbouring views.
static void make_host(host* h) {
    uint64_t random = 5;
    memset(h, 0, sizeof *h);
    h->scene.view_count = VIEWS;
    h->scene.views = h->views;
    for (int v = 0; v < VIEWS; v++) {
        gsf_camera* camera = &h->views[v].camera;
        const double c2w[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.3 * v - 0.9, 0.05 * (v % 3), 0, 1};
        gsf_set_camera_c2w(camera, c2w);
        camera->width = WIDTH;
        camera->height = HEIGHT;
        camera->fx = camera->fy = 60.0;
        camera->cx = 0.5 * WIDTH;
        camera->cy = 0.5 * HEIGHT;
        h->views[v].image = gsf_wrap_image(h->pixels[v], GSF_U8, WIDTH, HEIGHT, 3);
        for (int i = 0; i < WIDTH * HEIGHT; i++) {
            const double x = c2w[12] + 4.0 * (i % WIDTH + 0.5 - camera->cx) / camera->fx;
            const double y = c2w[13] + 4.0 * (i / WIDTH + 0.5 - camera->cy) / camera->fy;
            const double detail = sin(23.0 * x * y + 3.0 * x);
            for (int c = 0; c < 3; c++)
                h->pixels[v][3 * i + c] = (uint8_t)(128.0 + 60.0 * sin(9.0 * x + c) * cos(7.0 * y) + 60.0 * detail);
        }
    }
    h->scene.point_count = POINTS;
    h->scene.points = h->points;
    h->scene.colors = h->colors;
    h->scene.track_begin = h->track_begin;
    h->scene.track_views = h->track_views;
    for (size_t i = 0; i < POINTS; i++) {
        h->points[3 * i] = test_random_in(&random, -1.6, 1.6);
        h->points[3 * i + 1] = test_random_in(&random, -1.2, 1.2);
        h->points[3 * i + 2] = 4.0;
        h->colors[3 * i] = (uint8_t)i;
        size_t n = h->track_begin[i];
        for (uint32_t v = 0; v < 3 && i % 3 != 0; v++) h->track_views[n++] = (uint32_t)(i % 5) + v;
        h->track_begin[i + 1] = n;
    }
}

static int same_splats(const gsf_splats* a, const gsf_splats* b) {
    return a->count == b->count && a->sh_degree == b->sh_degree &&
           memcmp(a->means, b->means, 3 * a->count * sizeof(float)) == 0 &&
           memcmp(a->log_scales, b->log_scales, 3 * a->count * sizeof(float)) == 0;
}

static size_t count_kind(gsf_context* ctx, const host* h, gsf_initial_kind kind, size_t views, gsf_initial_stats* stats) {
    gsf_initial_desc desc = {0};
    gsf_splats splats;
    const uint32_t list[VIEWS] = {0, 1, 2, 3, 4, 5, 6};
    desc.kind = kind;
    desc.random_points = 50;
    CHECK_OK(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, list, views, &desc, &splats, stats));
    const size_t count = splats.count;
    CHECK(count == stats->scene_points + stats->new_points && splats.sh_degree == 3);
    gsf_splat_destroy(ctx, &splats);
    return count;
}

static void test_kinds(gsf_context* ctx, const host* h) {
    gsf_initial_stats stats, both;
    size_t on_track = 0; // points with a track in the first three views
    for (size_t i = 0; i < POINTS; i++) on_track += i % 3 != 0 && i % 5 < 3;
    CHECK(count_kind(ctx, h, GSF_INITIAL_ALL, 3, &stats) == POINTS && stats.visibility.points == 0);
    CHECK(count_kind(ctx, h, GSF_INITIAL_TRACKS, 3, &stats) == on_track && stats.visibility.rays == 0);
    CHECK(count_kind(ctx, h, GSF_INITIAL_RAYS, 3, &stats) > 0 && stats.visibility.by_tracks == 0);
    CHECK(count_kind(ctx, h, GSF_INITIAL_BOTH, 3, &both) > on_track && both.new_points == 0);
    CHECK(count_kind(ctx, h, GSF_INITIAL_RANDOM, 3, &stats) == 50 && stats.scene_points == 0);
    CHECK(count_kind(ctx, h, GSF_INITIAL_DENSE, 3, &stats) > both.scene_points);
    CHECK(stats.scene_points == both.scene_points && stats.dense.pairs > 0 && stats.new_points <= 40000);
    // the kind that GSF_INITIAL_AUTO selects
    count_kind(ctx, h, GSF_INITIAL_AUTO, 1, &stats);
    CHECK(stats.used.kind == GSF_INITIAL_BOTH);
    count_kind(ctx, h, GSF_INITIAL_AUTO, 2, &stats);
    CHECK(stats.used.kind == GSF_INITIAL_DENSE);
    host empty = *h;
    empty.scene.point_count = 0;
    count_kind(ctx, &empty, GSF_INITIAL_AUTO, 6, &stats);
    CHECK(stats.used.kind == GSF_INITIAL_RANDOM && stats.new_points == 50);
}

static void test_random_points(gsf_context* ctx, const host* h) {
    gsf_initial_desc desc = {0};
    gsf_splats splats;
    desc.kind = GSF_INITIAL_RANDOM;
    desc.random_points = 70;
    CHECK_OK(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, NULL, VIEWS, &desc, &splats, NULL));
    for (size_t i = 0; i < splats.count; i++) { // each projects into its view and has the colour of that pixel
        const float* mean = splats.means + 3 * i;
        const double point[3] = {mean[0], mean[1], mean[2]};
        double u, v, z;
        const int inside = gsf_project_point(&h->views[i % VIEWS].camera, point, &u, &v, &z);
        if (!CHECK(inside && u > -1e-3 && u < WIDTH + 1e-3 && v > -1e-3 && v < HEIGHT + 1e-3)) continue;
        // near an edge, float32 rounding may move the point to the next pixel
        if (fabs(u - floor(u) - 0.5) > 0.49 || fabs(v - floor(v) - 0.5) > 0.49) continue;
        const uint8_t* pixel = h->pixels[i % VIEWS] + 3 * ((size_t)v * WIDTH + (size_t)u);
        CHECK_NEAR(splats.sh[48 * i] * 0.28209479177387814 + 0.5, pixel[0] / 255.0, 1e-5);
    }
    gsf_splat_destroy(ctx, &splats);
}

static void test_desc(gsf_context* ctx, const host* h) {
    gsf_initial_desc desc = {0};
    gsf_splats all, listed;
    const uint32_t list[VIEWS] = {0, 1, 2, 3, 4, 5, 6}, wrong[2] = {0, VIEWS};
    CHECK_OK(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, NULL, VIEWS, NULL, &all, NULL));
    CHECK_OK(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, list, VIEWS, &desc, &listed, NULL));
    CHECK(same_splats(&all, &listed));
    gsf_splat_destroy(ctx, &listed);
    desc.sh_degree = -1;
    CHECK_OK(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, list, VIEWS, &desc, &listed, NULL));
    CHECK(listed.sh_degree == 0 && listed.count == all.count);
    gsf_splat_destroy(ctx, &listed);
    gsf_splat_destroy(ctx, &all);
    desc.sh_degree = 4;
    CHECK_RESULT(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, list, 2, &desc, &all, NULL),
                 GSF_ERROR_INVALID_ARGUMENT);
    desc.sh_degree = 0;
    desc.kind = GSF_INITIAL_RANDOM;
    CHECK_RESULT(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, wrong, 2, &desc, &all, NULL),
                 GSF_ERROR_INVALID_ARGUMENT);
    desc.random_points = -1;
    CHECK_RESULT(ctx, gsf_splat_make_initial_splats(ctx, &h->scene, list, 2, &desc, &all, NULL),
                 GSF_ERROR_INVALID_ARGUMENT);
    host blind = *h;
    blind.views[1].image.data = NULL;
    blind.scene.views = blind.views;
    desc.random_points = 0;
    CHECK_RESULT(ctx, gsf_splat_make_initial_splats(ctx, &blind.scene, list, 2, &desc, &all, NULL),
                 GSF_ERROR_INVALID_ARGUMENT);
    blind.scene.point_count = 0;
    desc.kind = GSF_INITIAL_BOTH;
    CHECK_RESULT(ctx, gsf_splat_make_initial_splats(ctx, &blind.scene, list, 2, &desc, &all, NULL),
                 GSF_ERROR_DEGENERATE);
    blind = *h;
    memset(blind.track_begin, 0, sizeof blind.track_begin);
    blind.scene.track_begin = blind.track_begin;
    desc.kind = GSF_INITIAL_TRACKS;
    CHECK_RESULT(ctx, gsf_splat_make_initial_splats(ctx, &blind.scene, list, 2, &desc, &all, NULL),
                 GSF_ERROR_DEGENERATE);
}

static void test_memory(const host* h) {
    static const gsf_initial_kind kinds[] = {GSF_INITIAL_BOTH, GSF_INITIAL_DENSE, GSF_INITIAL_RANDOM};
    for (size_t k = 0; k < sizeof kinds / sizeof *kinds; k++) {
        gsf_context ctx;
        counter memory = {0};
        gsf_initial_desc desc = {0};
        gsf_splats splats;
        test_context_zero(&ctx);
        count_memory(&ctx, &memory);
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        desc.kind = kinds[k];
        desc.random_points = 20;
        desc.dense.max_size = 40;
        desc.dense.levels = desc.dense.iterations = desc.dense.sources = 1;
        desc.visibility.use_zbuffer = 1; // Embree allocates outside the context's allocator
        const uint32_t list[2] = {2, 3};
        gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
        size_t failures = 0;
        for (; result == GSF_ERROR_OUT_OF_MEMORY && failures < 2000; failures++) {
            memory.calls = 0;
            memory.fail_at = failures + 1;
            result = gsf_splat_make_initial_splats(&ctx, &h->scene, list, 2, &desc, &splats, NULL);
            if (result != GSF_OK && !CHECK(memory.live == 0 && splats.count == 0)) break;
        }
        CHECK(result == GSF_OK && failures > 5);
        gsf_splat_destroy(&ctx, &splats);
        CHECK(memory.live == 0);
    }
}

static void test_settings(gsf_context* ctx, host* h) {
    const gsf_fix_desc alone = gsf_splat_resolve_few_view_desc(NULL, 6, GSF_QUALITY_BALANCED);
    const gsf_fix_desc three = gsf_splat_resolve_few_view_desc(NULL, 3, GSF_QUALITY_BALANCED);
    const gsf_fix_desc four = gsf_splat_resolve_few_view_desc(NULL, 4, GSF_QUALITY_BALANCED);
    CHECK(three.train.dropout == 0.2f && three.train.opacity_decay == 0.004f);
    CHECK(four.train.dropout == 0.1f * 1.5f && four.train.opacity_decay == 0.002f * 1.5f);
    CHECK(three.train.lr_scales == 0.005f && alone.train.lr_scales == 0.005f);
    CHECK_NEAR(gsf_splat_resolve_few_view_desc(NULL, 8, GSF_QUALITY_BALANCED).train.lr_scales, 0.005 * 5.0 / 3.0, 1e-8);
    CHECK(gsf_splat_resolve_few_view_desc(NULL, 9, GSF_QUALITY_BALANCED).train.lr_scales == 0.01f);
    CHECK(gsf_splat_resolve_few_view_desc(NULL, 50, GSF_QUALITY_BALANCED).train.lr_scales == 0.01f);
    CHECK(alone.train.iterations == 1200 && alone.train.dropout == 0.1f && alone.train.opacity_decay == 0.002f);
    CHECK(alone.train.depth_smoothness == 0.5f && alone.skip_psnr == 45.0f && !alone.train.lazy_adam);
    CHECK(alone.train.background_kind == GSF_BACKGROUND_PHOTOS);
    CHECK(!alone.points && alone.train.render.near_plane == 0.0f);
    const gsf_fix_desc fast = gsf_splat_resolve_few_view_desc(NULL, 6, GSF_QUALITY_FAST);
    CHECK(fast.skip_psnr == 36.0f && fast.max_pixels == 320 * 240 && fast.train.lazy_adam);
    CHECK(gsf_splat_resolve_few_view_desc(NULL, 6, GSF_QUALITY_EXACT).skip_psnr == 0.0f);
    const gsf_fix_desc desc = gsf_splat_resolve_few_view_desc(&h->scene, 6, GSF_QUALITY_BALANCED);
    CHECK(desc.points == h->points && desc.point_count == POINTS);
    CHECK_NEAR(desc.train.render.near_plane, 0.011 * 0.9, 1e-4); // the outer cameras are 0.9 from the middle
    gsf_camera far_apart[2] = {h->views[0].camera, h->views[0].camera};
    CHECK(gsf_splat_measure_near_plane(far_apart, sizeof *far_apart, 2) == 0.2f); // cameras in one place: no extent
    far_apart[1].w2c[12] += 1000.0;
    CHECK(gsf_splat_measure_near_plane(far_apart, sizeof *far_apart, 2) == 0.2f);

    const uint32_t some[2] = {4, 1}, wrong[1] = {VIEWS};
    gsf_train_view* views;
    CHECK_OK(ctx, gsf_splat_load_train_views(ctx, &h->scene, some, 2, &views));
    CHECK(views[0].image.data == h->pixels[4] && views[1].camera.w2c[12] == h->views[1].camera.w2c[12]);
    gsf_free(ctx, views);
    CHECK_RESULT(ctx, gsf_splat_load_train_views(ctx, &h->scene, wrong, 1, &views), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(!views);
}

int main(void) {
    static host h;
    gsf_context ctx;
    test_context_init(&ctx);
    make_host(&h);
    test_kinds(&ctx, &h);
    test_random_points(&ctx, &h);
    test_desc(&ctx, &h);
    test_memory(&h);
    test_settings(&ctx, &h);
    return test_report();
}
