// Dense points by PatchMatch stereo: planes of known depth, a ray-traced scene, and invalid or degenerate input.
// gcc -O2 -std=c11 -fopenmp -I. -Itests -DGSF_USE_EMBREE -DGSFIXER_IMPLEMENTATION tests/test_stereo.c -lembree3 -lm
#define _XOPEN_SOURCE 700 // mkdir
#define _POSIX_C_SOURCE 200809L
#include "gsfixer_splat.h"

#include "test.h"
#include "test_hooks.h"
#ifdef GSF_USE_EMBREE
#include "made_scene.h"
#endif

#include <unistd.h>

static gsf_context ctx;

// ---- hooks ---------------------------------------------------------------------

typedef struct heap { size_t calls, fail_at; int64_t live; } heap; // fail_at: 1-based, 0 = never

static void* heap_alloc(void* user, size_t size) {
    heap* h = (heap*)user;
    if (++h->calls == h->fail_at) return NULL;
    size_t* block = (size_t*)malloc(size + 16);
    if (!block) return NULL;
    block[0] = size;
    h->live += (int64_t)size;
    return block + 2;
}
static void heap_free(void* user, void* memory) {
    size_t* block = (size_t*)memory - 2;
    ((heap*)user)->live -= (int64_t)block[0];
    free(block);
}

// ---- a textured plane ----------------------------------------------------------

static double lattice_value(int64_t x, int64_t y, uint64_t octave) {
    return gsf_draw_uniform(7, octave, (uint64_t)(x & 0xffff) << 16 | (uint64_t)(y & 0xffff));
}

static double texture(double u, double v) { // three octaves of smooth noise, [0,1]
    double sum = 0.0;
    for (uint64_t octave = 0; octave < 3; octave++, u *= 2.1, v *= 2.1) {
        const double fu = u - floor(u), fv = v - floor(v), a = fu * fu * (3.0 - 2.0 * fu), b = fv * fv * (3.0 - 2.0 * fv);
        const int64_t iu = (int64_t)floor(u), iv = (int64_t)floor(v);
        sum += (lattice_value(iu, iv, octave) * (1 - a) + lattice_value(iu + 1, iv, octave) * a) * (1 - b) +
               (lattice_value(iu, iv + 1, octave) * (1 - a) + lattice_value(iu + 1, iv + 1, octave) * a) * b;
    }
    return sum / 3.0;
}

enum { WIDTH = 96, HEIGHT = 96, VIEWS = 3 }; // twice the smallest coarser level

typedef struct plane_scene {
    gsf_scene scene;
    gsf_scene_view views[VIEWS];
    double point[3], normal[3]; // of the plane
} plane_scene;

static double plane_depth(const plane_scene* s, const gsf_camera* camera, double u, double v, double at[3]) {
    double c2w[16], ray[3] = {(u - camera->cx) / camera->fx, (v - camera->cy) / camera->fy, 1.0}, a = 0.0, b = 0.0;
    gsf_get_camera_c2w(camera, c2w);
    double direction[3];
    for (int k = 0; k < 3; k++) {
        direction[k] = c2w[k] * ray[0] + c2w[4 + k] * ray[1] + c2w[8 + k] * ray[2];
        a += s->normal[k] * (s->point[k] - c2w[12 + k]);
        b += s->normal[k] * direction[k];
    }
    for (int k = 0; k < 3; k++) at[k] = c2w[12 + k] + direction[k] * a / b;
    return a / b;
}

// Three views about 8 degrees apart look at a plane 5 units away, turned by `tilt` (radians) about the vertical.
static void make_plane(plane_scene* s, double tilt, double contrast, double offset) {
    memset(s, 0, sizeof *s);
    s->point[0] = offset;
    s->point[2] = 5.0;
    s->normal[0] = sin(tilt);
    s->normal[2] = -cos(tilt);
    s->scene.view_count = VIEWS;
    s->scene.views = s->views;
    for (int i = 0; i < VIEWS; i++) {
        gsf_scene_view* view = &s->views[i];
        const double angle = 0.14 * (i - 1);
        const double c2w[16] = {cos(angle), 0, sin(angle), 0, 0, 1, 0, 0, -sin(angle), 0, cos(angle), 0,
                                offset + 5.0 * sin(angle), 0.2 * (i == 1), 5.0 - 5.0 * cos(angle), 1};
        view->camera.fx = view->camera.fy = 100.0;
        view->camera.cx = WIDTH / 2.0 + 1.3;
        view->camera.cy = HEIGHT / 2.0 - 0.7;
        view->camera.width = WIDTH;
        view->camera.height = HEIGHT;
        gsf_set_camera_c2w(&view->camera, c2w);
        CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_U8, WIDTH, HEIGHT, 3, &view->image));
        uint8_t* rgb = (uint8_t*)view->image.data;
        for (int y = 0; y < HEIGHT; y++)
            for (int x = 0; x < WIDTH; x++) {
                double sum = 0.0, spot[3];
                for (int k = 0; k < 4; k++) {
                    plane_depth(s, &view->camera, x + 0.25 + 0.5 * (k & 1), y + 0.25 + 0.5 * (k >> 1), spot);
                    sum += texture((spot[0] - offset) * 4.0 + 100.0, spot[1] * 4.0 + 100.0);
                }
                for (int k = 0; k < 3; k++)
                    rgb[3 * (y * WIDTH + x) + k] = (uint8_t)(128.0 + contrast * (sum / 4.0 - 0.5) + 0.5);
            }
    }
}

// Replaces the plane's texture by noisy stripes whose grey repeats every 8 pixels. Unless `hue` is 0, they have different
// hues of the same grey.
static void paint_stripes(plane_scene* s, double hue) {
    for (int i = 0; i < VIEWS; i++)
        for (int y = 0; y < HEIGHT; y++)
            for (int x = 0; x < WIDTH; x++) {
                double spot[3];
                plane_depth(s, &s->views[i].camera, x + 0.5, y + 0.5, spot);
                const double noise = gsf_draw_normal(3, (uint64_t)i, (uint64_t)(y * WIDTH + x));
                const double grey = 128.0 + 40.0 * sin(spot[0] * 2.0 * 3.14159265358979 / 0.4) + 8.0 * noise;
                const double red = hue * (texture(spot[0] * 1.5 + 100.0, spot[1] * 1.5 + 100.0) - 0.5);
                uint8_t* rgb = (uint8_t*)s->views[i].image.data + 3 * (y * WIDTH + x);
                rgb[0] = (uint8_t)(grey + red + 0.5);
                rgb[1] = (uint8_t)(grey - red * 77.0 / 150.0 + 0.5);
                rgb[2] = (uint8_t)(grey + 0.5);
            }
}

static void free_plane(plane_scene* s) {
    for (int i = 0; i < VIEWS; i++) gsf_destroy_image(&ctx, &s->views[i].image);
}

static const uint32_t all_views[VIEWS] = {0, 1, 2};

// Share of all pixels whose depth is accepted and right to 2 %.
static double right_share(const plane_scene* s) {
    gsf_dense dense;
    gsf_dense_desc desc = {0};
    size_t right = 0;
    double at[3];
    desc.want_maps = 1;
    if (!CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s->scene, all_views, VIEWS, NULL, &desc, &dense, NULL))) return 0.0;
    for (size_t i = 0; i < dense.map_count; i++)
        for (int k = 0; k < WIDTH * HEIGHT; k++) {
            const gsf_camera* camera = &dense.maps[i].camera;
            const double z = plane_depth(s, camera, k % WIDTH + 0.5, k / WIDTH + 0.5, at);
            right += fabs((double)dense.maps[i].depth[k] / z - 1.0) < 0.02;
        }
    gsf_splat_destroy_dense(&ctx, &dense);
    return (double)right / (VIEWS * WIDTH * HEIGHT);
}

// Where grey repeats, colours tell which match is the right one.
static void test_colors(void) {
    plane_scene s;
    make_plane(&s, 0.0, 220.0, 0.0);
    paint_stripes(&s, 0.0);
    const double grey = right_share(&s);
    paint_stripes(&s, 160.0);
    const double colored = right_share(&s);
    printf("stripes: %.3f right with their hues, %.3f without\n", colored, grey);
    CHECK(grey < 0.5 && colored > 0.7);
    free_plane(&s);
}

static void check_plane(double tilt, double offset) {
    plane_scene s;
    make_plane(&s, tilt, 220.0, offset);
    gsf_dense dense;
    gsf_dense_stats stats;
    gsf_dense_desc desc = {0};
    desc.want_maps = 1;
    if (!CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, &desc, &dense, &stats))) {
        free_plane(&s);
        return;
    }
    size_t accepted = 0, good = 0, facing = 0;
    double sum = 0.0;
    CHECK(dense.map_count == VIEWS);
    for (size_t i = 0; i < dense.map_count; i++) {
        const gsf_dense_map* map = &dense.maps[i];
        CHECK(map->view == i && map->camera.width == WIDTH && map->camera.height == HEIGHT);
        for (int y = 0; y < HEIGHT; y++)
            for (int x = 0; x < WIDTH; x++) {
                const float z = map->depth[y * WIDTH + x], *n = map->normals + 3 * (y * WIDTH + x);
                if (z == 0.0f) continue;
                double spot[3], dot = 0.0;
                const double truth = plane_depth(&s, &map->camera, x + 0.5, y + 0.5, spot), error = fabs(z - truth) / truth;
                for (int k = 0; k < 3; k++) dot += (double)n[k] * s.normal[k];
                accepted++;
                sum += error;
                good += error < 0.01;
                facing += dot > 0.94; // 20 degrees
            }
    }
    size_t on = 0, near = 0;
    for (size_t i = 0; i < dense.count; i++) {
        double distance = 0.0, dot = 0.0;
        for (size_t k = 0; k < 3; k++) {
            distance += (dense.points[3 * i + k] - s.point[k]) * s.normal[k];
            dot += (double)dense.normals[3 * i + k] * s.normal[k];
        }
        on += fabs(distance) < 0.05;
        near += dot > 0.94;
        CHECK(dense.view_counts[i] >= 2 && dense.view_counts[i] <= VIEWS && dense.confidence[i] >= 0.5f);
    }
    printf("plane tilted %.0f degrees, %g from the zero: %zu of %d pixels, mean error %.5f, %.4f within 1 %%, "
           "normals %.3f; %zu points, %.3f on it, %.3f normals\n", tilt * 57.3, offset, accepted, VIEWS * WIDTH * HEIGHT,
           sum / (double)accepted, (double)good / (double)accepted, (double)facing / (double)accepted, dense.count,
           (double)on / (double)dense.count, (double)near / (double)dense.count);
    CHECK(accepted > (size_t)(0.6 * VIEWS * WIDTH * HEIGHT));
    // 1 % of the depth is 0.14 pixels here
    CHECK(sum / (double)accepted < 0.005 && good > 0.92 * (double)accepted && facing > 0.9 * (double)accepted);
    CHECK(dense.count > 500 && on > 0.92 * (double)dense.count && near > 0.9 * (double)dense.count);
    CHECK(stats.views == VIEWS && stats.pairs == 6 && stats.consistent == accepted && stats.matched >= accepted);
    gsf_splat_destroy_dense(&ctx, &dense);
    CHECK(dense.points == NULL && dense.count == 0);
    free_plane(&s);
}

// The views' rays meet at 8 and 16 degrees: a min_angle between the two leaves fewer pairs, one above them leaves none.
// If normals may not differ at all, few points are left; if they may differ by any angle, more than by default.
static void test_angles(void) {
    static const struct { float min_angle, max_normal_angle; uint32_t pairs; } cases[] = {
        {0.0f, 0.0f, 6}, {12.0f, 0.0f, 2}, {25.0f, 0.0f, 0}, {0.0f, 2.0f, 6}, {0.0f, 180.0f, 6}};
    enum { CASES = (int)(sizeof cases / sizeof *cases), POINTS = 60 };
    static double points[3 * POINTS]; // points that decide which views are paired
    static uint8_t colors[3 * POINTS];
    static size_t tracks[POINTS + 1];
    size_t consistent[CASES];
    plane_scene s;
    make_plane(&s, 0.2, 60.0, 0.0);
    for (size_t i = 0; i < POINTS; i++)
        plane_depth(&s, &s.views[1].camera, 30.0 + 4.0 * (double)(i % 10), 25.0 + 5.0 * (double)(i / 10), points + 3 * i);
    s.scene.points = points;
    s.scene.colors = colors;
    s.scene.track_begin = tracks;
    s.scene.point_count = POINTS;
    for (int i = 0; i < CASES; i++) {
        gsf_dense dense;
        gsf_dense_stats stats;
        gsf_dense_desc desc = {0};
        desc.min_angle = cases[i].min_angle;
        desc.max_normal_angle = cases[i].max_normal_angle;
        memset(&stats, 0, sizeof stats);
        CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, &desc, &dense, &stats));
        CHECK(stats.pairs == cases[i].pairs);
        consistent[i] = stats.consistent;
        printf("min_angle %g, max_normal_angle %g: %zu pairs, %zu consistent\n", (double)desc.min_angle,
               (double)desc.max_normal_angle, (size_t)stats.pairs, consistent[i]);
        gsf_splat_destroy_dense(&ctx, &dense);
    }
    CHECK(consistent[2] == 0 && consistent[3] * 2 < consistent[0] && consistent[0] < consistent[4]);
    free_plane(&s);
}

// The left 40 columns of view 1 have weight 0: they yield no points, that view's depth map is empty there, and random
// colours there change no bit of the points and their colours.
static void test_masked(void) {
    plane_scene s;
    gsf_dense dense[2];
    uint8_t weight[WIDTH * HEIGHT];
    make_plane(&s, 0.2, 200.0, 0.0);
    for (int i = 0; i < WIDTH * HEIGHT; i++) weight[i] = i % WIDTH < 40 ? 0 : 255;
    s.views[1].weight = gsf_wrap_image(weight, GSF_U8, WIDTH, HEIGHT, 1);
    const gsf_dense_desc desc = {.levels = 2, .want_maps = 1, .spacing = 1};
    for (int run = 0; run < 2; run++) {
        uint64_t state = 5;
        uint8_t* rgb = (uint8_t*)s.views[1].image.data;
        for (int i = 0; i < 3 * WIDTH * HEIGHT && run; i++)
            if (weight[i / 3] == 0) rgb[i] = (uint8_t)test_random_in(&state, 0, 255.9);
        CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, &desc, &dense[run], NULL));
        size_t masked = 0, open = 0, elsewhere = 0;
        for (size_t m = 0; m < dense[run].map_count; m++)
            for (int i = 0; i < WIDTH * HEIGHT; i++) {
                const int found = dense[run].maps[m].depth[i] > 0.0f;
                if (dense[run].maps[m].view != 1) elsewhere += found;
                else if (weight[i]) open += found;
                else masked += found;
            }
        CHECK(masked == 0 && open > 1000 && elsewhere > 2000);
    }
    CHECK(dense[0].count == dense[1].count);
    if (dense[0].count == dense[1].count) {
        CHECK(memcmp(dense[0].points, dense[1].points, 3 * dense[0].count * sizeof(double)) == 0);
        CHECK(memcmp(dense[0].colors, dense[1].colors, 3 * dense[0].count) == 0);
    }
    for (int run = 0; run < 2; run++) gsf_splat_destroy_dense(&ctx, &dense[run]);
    free_plane(&s);
}

static void test_nothing_to_see(void) {
    plane_scene s;
    gsf_dense dense;
    gsf_dense_stats stats;
    make_plane(&s, 0.0, 0.0, 0.0);
    CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, NULL, &dense, &stats));
    CHECK(dense.count == 0 && stats.matched == 0 && dense.map_count == 0);
    gsf_splat_destroy_dense(&ctx, &dense);
    free_plane(&s);

    make_plane(&s, 0.0, 220.0, 0.0);
    static const uint32_t same[3] = {1, 1, 1};
    for (size_t n = 0; n <= 3; n++) { // no view, one view, and a view that is listed repeatedly
        CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, same, n, NULL, NULL, &dense, &stats));
        CHECK(dense.count == 0 && stats.views == (n > 0) && stats.pairs == 0);
        gsf_splat_destroy_dense(&ctx, &dense);
    }
    double c2w[16]; // the third looks away: one pair of two views is left
    gsf_get_camera_c2w(&s.views[2].camera, c2w);
    for (int k = 0; k < 3; k++) c2w[k] = -c2w[k], c2w[8 + k] = -c2w[8 + k];
    gsf_set_camera_c2w(&s.views[2].camera, c2w);
    CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, NULL, &dense, &stats));
    CHECK(dense.count > 100 && stats.views == VIEWS && stats.pairs == 2);
    gsf_splat_destroy_dense(&ctx, &dense);
    free_plane(&s);
}

static void expect_refused(plane_scene* s, const uint32_t* views, size_t count, const gsf_dense_desc* desc) {
    gsf_dense dense;
    ctx.error[0] = 0;
    CHECK(gsf_splat_make_dense(&ctx, &s->scene, views, count, NULL, desc, &dense, NULL) != GSF_OK && ctx.error[0]);
    CHECK(dense.points == NULL && dense.count == 0);
}

static void test_refused(void) {
    plane_scene s;
    make_plane(&s, 0.0, 220.0, 0.0);
    const gsf_camera camera = s.views[1].camera;
    const gsf_image image = s.views[1].image;
    static const uint32_t beyond[2] = {0, 3};
    expect_refused(&s, beyond, 2, NULL);
    expect_refused(&s, NULL, 2, NULL);
    s.views[1].camera.w2c[5] = NAN;
    expect_refused(&s, all_views, VIEWS, NULL);
    s.views[1].camera = camera;
    s.views[1].camera.fx = INFINITY;
    expect_refused(&s, all_views, VIEWS, NULL);
    s.views[1].camera = camera;
    s.views[1].image.data = NULL;
    expect_refused(&s, all_views, VIEWS, NULL);
    s.views[1].image = image;
    s.views[1].camera.width--;
    expect_refused(&s, all_views, VIEWS, NULL);
    s.views[1].camera = camera;
    gsf_dense_desc desc[8];
    memset(desc, 0, sizeof desc);
    desc[0].max_cost = NAN;
    desc[1].radius = 16;
    desc[2].radius = 15, desc[2].stride = 1;
    desc[3].sources = 9;
    desc[4].depth_min = 2.0, desc[4].depth_max = 1.0;
    desc[5].spacing = -1;
    desc[6].max_size = 8;
    desc[7].depth_max = NAN;
    for (int i = 0; i < 8; i++) expect_refused(&s, all_views, VIEWS, &desc[i]);
    free_plane(&s);
}

static gsf_dense_desc quick_desc(void) {
    gsf_dense_desc desc = {0};
    desc.iterations = 1;
    desc.spacing = 3;
    desc.want_maps = 1;
    return desc;
}

static void test_same_bits(void) {
    plane_scene s;
    gsf_dense first, again;
    const gsf_dense_desc desc = quick_desc();
    make_plane(&s, 0.5, 220.0, 0.0);
    gsf_context other[4]; // defaults, one worker, reverse order, scalar
    memset(other, 0, sizeof other);
    other[1].threads = 1;
    work_backwards(&other[2]);
    other[3].cpu_level = GSF_CPU_SCALAR;
    CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, &desc, &first, NULL));
    CHECK(first.count > 100);
    for (int i = 0; i < 4; i++) {
        CHECK_OK(&other[i], gsf_init_context(&other[i]));
        CHECK_OK(&other[i], gsf_splat_make_dense(&other[i], &s.scene, all_views, VIEWS, NULL, &desc, &again, NULL));
        int same = again.count == first.count && again.map_count == first.map_count;
        same = same && memcmp(again.points, first.points, first.count * 3 * sizeof(double)) == 0 &&
               memcmp(again.normals, first.normals, first.count * 3 * sizeof(float)) == 0 &&
               memcmp(again.colors, first.colors, first.count * 3) == 0 &&
               memcmp(again.confidence, first.confidence, first.count * sizeof(float)) == 0;
        for (size_t m = 0; same && m < first.map_count; m++)
            same = memcmp(again.maps[m].depth, first.maps[m].depth, WIDTH * HEIGHT * sizeof(float)) == 0;
        if (!CHECK(same)) fprintf(stderr, "  run %d differs\n", i);
        gsf_splat_destroy_dense(&other[i], &again);
    }
    gsf_dense_desc seeded = desc; // another seed gives other results
    seeded.seed = 1;
    CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, &seeded, &again, NULL));
    CHECK(again.count != first.count || memcmp(again.points, first.points, first.count * 3 * sizeof(double)) != 0);
    gsf_splat_destroy_dense(&ctx, &again);

    gsf_dense_desc capped = desc;
    capped.max_points = first.count / 3;
    gsf_dense_stats stats;
    CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, NULL, &capped, &again, &stats));
    CHECK(again.count <= capped.max_points && again.count > 20 && stats.spacing > 3);
    gsf_splat_destroy_dense(&ctx, &again);
    gsf_splat_destroy_dense(&ctx, &first);
    free_plane(&s);
}

// Sparse points guide the search, and no dense point is closer to a sparse one than the spacing.
static void test_beside_sparse_points(void) {
    enum { POINTS = 60 };
    plane_scene s;
    static double points[3 * POINTS];
    static uint8_t colors[3 * POINTS], keep[POINTS];
    static size_t tracks[POINTS + 1];
    make_plane(&s, 0.4, 220.0, 0.0);
    for (size_t i = 0; i < POINTS; i++) {
        plane_depth(&s, &s.views[1].camera, 8.0 + 8.0 * (double)(i % 10), 10.0 + 10.0 * (double)(i / 10), points + 3 * i);
        keep[i] = i % 10 < 5;
    }
    points[3] = NAN;
    s.scene.points = points;
    s.scene.colors = colors;
    s.scene.track_begin = tracks;
    s.scene.point_count = POINTS;
    gsf_dense_desc desc = quick_desc();
    desc.skip_sparse = 1;
    gsf_dense dense;
    CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, &s.scene, all_views, VIEWS, keep, &desc, &dense, NULL));
    double nearest_kept = 1e9, nearest_left = 1e9;
    for (size_t i = 0; i < dense.count; i++)
        for (size_t k = 0; k < POINTS; k++) {
            double sum = 0.0;
            if (k == 1) continue;
            for (size_t a = 0; a < 3; a++)
                sum += (dense.points[3 * i + a] - points[3 * k + a]) * (dense.points[3 * i + a] - points[3 * k + a]);
            double* nearest = keep[k] ? &nearest_kept : &nearest_left;
            if (sqrt(sum) < *nearest) *nearest = sqrt(sum);
        }
    printf("beside sparse points: %zu points, %.3f from those in use, %.3f from others\n", dense.count, nearest_kept,
           nearest_left);
    // a pixel covers 0.05, the spacing is 3 pixels
    CHECK(dense.count > 300 && nearest_kept > 0.08 && nearest_left < 0.05);
    gsf_splat_destroy_dense(&ctx, &dense);
    free_plane(&s);
}

static void test_out_of_memory_and_cancel(void) {
    plane_scene s;
    heap h;
    gsf_context small;
    gsf_dense dense;
    make_plane(&s, 0.2, 220.0, 0.0);
    gsf_dense_desc desc = quick_desc();
    desc.radius = 2;
    memset(&h, 0, sizeof h);
    test_context_zero(&small);
    small.allocator.alloc_fn = heap_alloc;
    small.allocator.free_fn = heap_free;
    small.allocator.user = &h;
    CHECK_OK(&small, gsf_init_context(&small));
    size_t last = 0;
    for (size_t k = 1; k < 1000; k++) {
        h.calls = 0;
        h.fail_at = k;
        const gsf_result result = gsf_splat_make_dense(&small, &s.scene, all_views, VIEWS, NULL, &desc, &dense, NULL);
        if (result == GSF_OK) {
            last = k;
            gsf_splat_destroy_dense(&small, &dense);
            CHECK(h.live == 0);
            break;
        }
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY && h.live == 0 && dense.points == NULL)) break;
    }
    CHECK(last > 10);
    h.fail_at = 0;
    gsf_request_cancel(&small);
    CHECK(gsf_splat_make_dense(&small, &s.scene, all_views, VIEWS, NULL, &desc, &dense, NULL) == GSF_ERROR_CANCELLED);
    CHECK(h.live == 0 && dense.points == NULL);
    free_plane(&s);
}

// ---- the ray-traced courtyard --------------------------------------------------

#ifdef GSF_USE_EMBREE

static float* load_truth(const char* folder, const char* name, size_t pixels) { // frame_007.png -> depth_007.npy
    char path[1200];
    size_t size = 0;
    snprintf(path, sizeof path, "%s/truth/depth_%.3s.npy", folder, name + 6);
    char* file = test_read_file(path, &size);
    float* depth = (float*)malloc(pixels * sizeof(float));
    if (!depth || size < pixels * sizeof(float)) exit(2);
    memcpy(depth, file + size - pixels * sizeof(float), pixels * sizeof(float));
    free(file);
    return depth;
}

static int compare_floats(const void* a, const void* b) {
    const float x = *(const float*)a, y = *(const float*)b;
    return (x > y) - (x < y);
}

// Does one of the other maps see the surface that pixel (x,y) of map m really shows?
static int seen_elsewhere(const gsf_dense* dense, float* const* truth, size_t m, int x, int y) {
    const gsf_camera* camera = &dense->maps[m].camera;
    const double z = (double)truth[m][y * camera->width + x];
    const double ray[3] = {(x + 0.5 - camera->cx) / camera->fx * z, (y + 0.5 - camera->cy) / camera->fy * z, z};
    double c2w[16], point[3], u, v, depth;
    gsf_get_camera_c2w(camera, c2w);
    for (int k = 0; k < 3; k++) point[k] = c2w[12 + k] + c2w[k] * ray[0] + c2w[4 + k] * ray[1] + c2w[8 + k] * ray[2];
    for (size_t i = 0; i < dense->map_count; i++) {
        const gsf_camera* other = &dense->maps[i].camera;
        if (i == m || !gsf_project_point(other, point, &u, &v, &depth)) continue;
        if (!(u >= 0.0 && u < other->width && v >= 0.0 && v < other->height)) continue;
        const double there = (double)truth[i][(int)v * other->width + (int)u];
        if (there > 0.0 && fabs(there - depth) < 0.02 * depth) return 1;
    }
    return 0;
}

typedef struct courtyard_limits { size_t views; double median, within_1, within_5, complete; } courtyard_limits;

static void check_courtyard(const gsf_scene* scene, const char* folder, const courtyard_limits* limits) {
    uint32_t train[16];
    size_t count = 0;
    gsf_splat_split_views(scene->view_count, 8, limits->views, train, &count, NULL, NULL);
    uint8_t* keep = (uint8_t*)calloc(scene->point_count, 1);
    gsf_dense_desc desc = {0};
    gsf_dense dense;
    gsf_dense_stats stats;
    desc.want_maps = 1;
    CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, scene, train, count, NULL, keep, NULL));
    if (!CHECK_OK(&ctx, gsf_splat_make_dense(&ctx, scene, train, count, keep, &desc, &dense, &stats))) return;
    float *truth[16], *errors = (float*)malloc((stats.consistent + 1) * sizeof(float));
    for (size_t m = 0; m < dense.map_count; m++)
        truth[m] = load_truth(folder, scene->views[dense.maps[m].view].name,
                              (size_t)dense.maps[m].camera.width * (size_t)dense.maps[m].camera.height);
    size_t n = 0, within[3] = {0, 0, 0}, possible = 0, found = 0;
    for (size_t m = 0; m < dense.map_count; m++)
        for (int y = 0; y < dense.maps[m].camera.height; y++)
            for (int x = 0; x < dense.maps[m].camera.width; x++) {
                const int at = y * dense.maps[m].camera.width + x;
                const float z = dense.maps[m].depth[at], t = truth[m][at];
                if (z > 0.0f) {
                    // a point in the sky counts as an error of 100 %
                    const float error = t > 0.0f ? fabsf(z - t) / t : 1.0f;
                    errors[n++] = error;
                    within[0] += error < 0.01f;
                    within[1] += error < 0.02f;
                    within[2] += error < 0.05f;
                }
                if (!(t > 0.0f) || !seen_elsewhere(&dense, truth, m, x, y)) continue;
                possible++;
                found += z > 0.0f;
            }
    CHECK(n == stats.consistent && n > 0);
    qsort(errors, n, sizeof *errors, compare_floats);
    const double all = (double)n, complete = (double)found / (double)possible;
    printf("courtyard, %zu views: median error %.5f, within 1, 2, 5 %%: %.3f %.3f %.3f; complete %.3f; %zu points, "
           "%.2f s\n", limits->views, (double)errors[n / 2], (double)within[0] / all, (double)within[1] / all,
           (double)within[2] / all, complete, dense.count, stats.seconds_prepare + stats.seconds_match + stats.seconds_fuse);
    CHECK((double)errors[n / 2] < limits->median);
    CHECK((double)within[0] / all > limits->within_1 && (double)within[2] / all > limits->within_5);
    CHECK(complete > limits->complete);
    for (size_t m = 0; m < dense.map_count; m++) free(truth[m]);
    free(errors);
    free(keep);
    gsf_splat_destroy_dense(&ctx, &dense);
}

static void test_courtyard(void) {
    static const courtyard_limits limits[] = {
        {3, 0.0035, 0.82, 0.975, 0.34}, {6, 0.0052, 0.72, 0.95, 0.47}, {9, 0.0056, 0.69, 0.945, 0.49}};
    char folder[1024];
    snprintf(folder, sizeof folder, "%s", test_scratch("courtyard"));
    make_scene_options options = make_scene_defaults;
    options.views = 16;
    options.width = 128;
    options.height = 96;
    options.noise *= 0.4;
    options.arc = 90.0;
    gsf_scene scene;
    if (CHECK(make_scene(&ctx, &options, folder) == 0) &&
        CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, folder, NULL, &scene))) {
        for (size_t i = 0; i < scene.view_count; i++) CHECK_OK(&ctx, gsf_splat_load_view_image(&ctx, &scene, i));
        for (size_t i = 0; i < sizeof limits / sizeof *limits; i++) check_courtyard(&scene, folder, &limits[i]);
        gsf_splat_destroy_scene(&ctx, &scene);
    }
    remove_scene(folder, options.views);
}

#endif // GSF_USE_EMBREE

int main(void) {
    test_context_init(&ctx);
    check_plane(0.0, 0.0);
    check_plane(0.7, 0.0);
    check_plane(-0.9, 1e6);
    test_colors();
    test_angles();
    test_masked();
    test_nothing_to_see();
    test_refused();
    test_same_bits();
    test_beside_sparse_points();
    test_out_of_memory_and_cancel();
#ifdef GSF_USE_EMBREE
    test_courtyard();
#else
    printf("no Embree: the courtyard is left out\n");
#endif
    return test_report();
}
