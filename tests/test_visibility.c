// Neighbours, initial splats from points, visible-point filter.
// gcc -O2 -std=c11 -I. -Itests -DGSF_USE_EMBREE tests/test_visibility.c -lembree3 -lm
#define _XOPEN_SOURCE 700 // mkdir
#define _POSIX_C_SOURCE 200809L
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"

#include "test.h"
#ifdef GSF_USE_EMBREE
#include "made_scene.h"
#endif

#include <unistd.h>

enum { SEEDS = 8, CHOICES = 3 }; // procedural scenes, and random choices of views in each

static gsf_context ctx;

// ---- neighbours ----------------------------------------------------------------

enum { CLOUD_UNIFORM, CLOUD_CLUSTERED, CLOUD_DUPLICATES, CLOUD_LINE, CLOUD_FAR, CLOUD_KINDS };

static void make_cloud(int kind, size_t count, double* points) {
    uint64_t state = 77 + (uint64_t)kind;
    for (size_t i = 0; i < count; i++) {
        double* p = points + 3 * i;
        for (int k = 0; k < 3; k++) p[k] = test_random_in(&state, -1.0, 1.0);
        if (kind == CLOUD_CLUSTERED) // nested clusters down to 1e-9, and one point in a thousand very far away
            for (int k = 0; k < 3; k++) p[k] *= i % 1000 == 0 ? 1e6 : pow(10.0, -(double)(i % 10));
        if (kind == CLOUD_DUPLICATES) for (int k = 0; k < 3; k++) p[k] = i % 3 ? 0.5 : floor(3.0 * p[k]);
        if (kind == CLOUD_LINE) p[0] = p[1] = 2.0;
        if (kind == CLOUD_FAR) p[0] += 4.5e6; // georeferenced
    }
}

static int compare_doubles(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return (x > y) - (x < y);
}

// Every query against brute force: bit-identical distances, points at exactly these distances, no point twice.
static void check_neighbours(int kind, size_t count, int k) {
    double* points = (double*)malloc((count + 1) * 3 * sizeof(double));
    double* brute = (double*)malloc((count + 1) * sizeof(double));
    make_cloud(kind, count, points);
    gsf__knn_tree tree;
    CHECK_OK(&ctx, gsf__knn_build(&ctx, points, count, NULL, &tree));
    CHECK(tree.count == count);
    int wrong_count = 0, wrong_distance = 0, wrong_place = 0;
    gsf__knn_near nearby;
    nearby.end = 0;
    for (size_t i = 0, leaf = 0; i < count; i++) {
        if (i == nearby.end) gsf__knn_leaf(&tree, leaf++, k, &nearby);
        const double *q = tree.points + 3 * i, *distance2 = nearby.distance2[i - nearby.first];
        const size_t* places = nearby.places[i - nearby.first];
        const int found = nearby.found[i - nearby.first];
        size_t n = 0;
        for (size_t j = 0; j < count; j++) {
            if (j == tree.rows[i]) continue;
            const double x = points[3 * j] - q[0], y = points[3 * j + 1] - q[1], z = points[3 * j + 2] - q[2];
            brute[n++] = x * x + y * y + z * z;
        }
        qsort(brute, n, sizeof *brute, compare_doubles);
        wrong_count += found != (n < (size_t)k ? (int)n : k);
        for (int a = 0; a < found; a++) {
            wrong_distance += distance2[a] != brute[a];
            const double* p = points + 3 * tree.rows[places[a]];
            const double x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
            wrong_place += places[a] == i || x * x + y * y + z * z != distance2[a];
            for (int b = 0; b < a; b++) wrong_place += places[a] == places[b];
        }
    }
    if (!CHECK(wrong_count == 0 && wrong_distance == 0 && wrong_place == 0))
        fprintf(stderr, "  cloud %d of %zu points, k = %d: %d counts, %d distances, %d places\n", kind, count, k,
                wrong_count, wrong_distance, wrong_place);
    gsf__arena_free(&tree.arena);
    free(points);
    free(brute);
}

static void test_neighbours(void) {
    static const size_t counts[] = {0, 1, 2, 3, 8, 9, 17, 100, 1000};
    for (int kind = 0; kind < CLOUD_KINDS; kind++)
        for (size_t c = 0; c < sizeof counts / sizeof *counts; c++) {
            check_neighbours(kind, counts[c], 3);
            check_neighbours(kind, counts[c], 12);
        }
    check_neighbours(CLOUD_CLUSTERED, 3000, GSF__KNN_MAX);

    // No cloud takes much longer than others: nested clusters, piles of equal points, a line.
    const size_t many = 100000;
    double* points = (double*)malloc(many * 3 * sizeof(double));
    for (int kind = 0; kind < CLOUD_KINDS; kind++) {
        make_cloud(kind, many, points);
        const double start = gsf__seconds();
        gsf__knn_tree tree;
        CHECK_OK(&ctx, gsf__knn_build(&ctx, points, many, NULL, &tree));
        const double built = gsf__seconds();
        double sum = 0.0;
        for (size_t leaf = 0; leaf < (size_t)1 << tree.levels; leaf++) {
            gsf__knn_near nearby;
            gsf__knn_leaf(&tree, leaf, 12, &nearby);
            for (size_t k = 0; k < nearby.end - nearby.first; k++) sum += nearby.found[k] == 12 ? nearby.distance2[k][11] : NAN;
        }
        CHECK(isfinite(sum));
        printf("neighbours: cloud %d, %zu points: tree %.2f s, 12 nearest of all %.2f s\n", kind, many, built - start,
               gsf__seconds() - built);
        gsf__arena_free(&tree.arena);
    }
    free(points);

    // Points with a non-finite coordinate and points that are not kept are ignored.
    double few[12] = {0, 0, 0, 1, NAN, 0, 0, 2, 0, 5, 5, INFINITY};
    const uint8_t keep[4] = {1, 1, 1, 1};
    gsf__knn_tree tree;
    CHECK_OK(&ctx, gsf__knn_build(&ctx, few, 4, keep, &tree));
    CHECK(tree.count == 2);
    gsf__arena_free(&tree.arena);
}

// ---- initial splats ------------------------------------------------------------

static void test_from_points(void) {
    test_tensors file = test_open_tensors(test_golden("splat/init_from_points.safetensors"));
    test_tensor points = test_get_tensor(&file, "in.points"), colors = test_get_tensor(&file, "in.colors");
    test_tensor xyz = test_get_tensor(&file, "out.xyz"), scaling = test_get_tensor(&file, "out.scaling");
    test_tensor rotation = test_get_tensor(&file, "out.rotation"), opacity = test_get_tensor(&file, "out.opacity");
    test_tensor dc = test_get_tensor(&file, "out.f_dc"), rest = test_get_tensor(&file, "out.f_rest");
    const size_t n = points.dim[0];
    uint8_t* bytes = (uint8_t*)malloc(3 * n);
    double error = 0.0;
    for (size_t i = 0; i < 3 * n; i++) bytes[i] = (uint8_t)(colors.v[i] * 255.0 + 0.5);
    gsf_splats splats;
    if (CHECK_OK(&ctx, gsf_splat_make_from_points(&ctx, points.v, bytes, n, NULL, 3, NULL, &splats)) &&
        CHECK(splats.count == n)) {
        test_compare_floats("means", splats.means, xyz.v, xyz.count, 1e-5);
        test_compare_floats("log_scales", splats.log_scales, scaling.v, scaling.count, 1e-5);
        test_compare_floats("quats", splats.quats, rotation.v, rotation.count, 1e-5);
        test_compare_floats("opacity_logits", splats.opacity_logits, opacity.v, opacity.count, 1e-5);
        for (size_t i = 0; i < n; i++)
            for (size_t c = 0; c < 3; c++) { // the file's colours are floats: compare after shifting to those of the bytes
                const double shift = (bytes[3 * i + c] / 255.0 - colors.v[3 * i + c]) / 0.28209479177387814;
                error = fmax(error, fabs((double)splats.sh[48 * i + c] - (dc.v[3 * i + c] + shift)));
                for (size_t k = 1; k < 16; k++)
                    error = fmax(error, fabs((double)splats.sh[48 * i + 3 * k + c] - rest.v[45 * i + 3 * (k - 1) + c]));
            }
        CHECK_NEAR(error, 0.0, 1e-5);
    }
    gsf_splat_destroy(&ctx, &splats);

    // A subset, relative to a far origin: rows become ids, distances are those within the subset.
    uint8_t* keep = (uint8_t*)calloc(n, 1);
    double* moved = (double*)malloc(3 * n * sizeof(double));
    const double origin[3] = {4.5e6, -2e5, 100.0};
    for (size_t i = 0; i < n; i++) {
        keep[i] = i % 2 == 1;
        for (size_t k = 0; k < 3; k++) moved[3 * i + k] = points.v[3 * i + k] + origin[k];
    }
    moved[3 * 3] = NAN;
    if (CHECK_OK(&ctx, gsf_splat_make_from_points(&ctx, moved, bytes, n, keep, 1, origin, &splats))) {
        CHECK(splats.count == n / 2 - 1 && splats.sh_degree == 1);
        CHECK(splats.ids[0] == 1 && splats.ids[1] == 5 && splats.origin[0] == origin[0]);
        for (size_t s = 0; s < splats.count; s++) {
            double best[3] = {1e300, 1e300, 1e300};
            const size_t i = splats.ids[s];
            for (size_t j = 1; j < n; j += 2) {
                if (j == i || j == 3) continue;
                double d = 0.0;
                for (size_t k = 0; k < 3; k++) d += pow(points.v[3 * i + k] - points.v[3 * j + k], 2.0);
                for (int k = 0; k < 3; k++)
                    if (d < best[k]) { const double t = best[k]; best[k] = d; d = t; }
            }
            CHECK_NEAR(splats.log_scales[3 * s], 0.5 * log(fmax((best[0] + best[1] + best[2]) / 3.0, 1e-7)), 1e-5);
            CHECK_NEAR(splats.means[3 * s + 1], points.v[3 * i + 1], 1e-6);
        }
    }
    gsf_splat_destroy(&ctx, &splats);

    // No point, one point, two points.
    for (size_t few = 0; few < 3; few++) {
        CHECK_OK(&ctx, gsf_splat_make_from_points(&ctx, points.v, bytes, few, NULL, 0, NULL, &splats));
        CHECK(splats.count == few);
        for (size_t i = 0; i < few; i++) CHECK(isfinite(splats.log_scales[3 * i]));
        gsf_splat_destroy(&ctx, &splats);
    }
    CHECK_RESULT(&ctx, gsf_splat_make_from_points(&ctx, points.v, bytes, n, NULL, 4, NULL, &splats),
                 GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(&ctx, gsf_splat_make_from_points(&ctx, NULL, bytes, n, NULL, 0, NULL, &splats),
                 GSF_ERROR_INVALID_ARGUMENT);
    free(keep);
    free(moved);
    free(bytes);
    test_free_tensor(&points); test_free_tensor(&colors); test_free_tensor(&xyz); test_free_tensor(&scaling);
    test_free_tensor(&rotation); test_free_tensor(&opacity); test_free_tensor(&dc); test_free_tensor(&rest);
    test_close_tensors(&file);
}

// ---- visible points ------------------------------------------------------------

static uint8_t* visible(const gsf_scene* scene, const uint32_t* views, size_t count, gsf_visibility_method method,
                        int use_zbuffer, gsf_visibility_stats* stats) { // malloc'd
    gsf_visibility_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.method = method;
    desc.use_zbuffer = use_zbuffer;
    uint8_t* keep = (uint8_t*)malloc(scene->point_count);
    CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, scene, views, count, &desc, keep, stats));
    return keep;
}

// K training views of the papers' split.
static size_t training_views(const gsf_scene* scene, size_t k, uint32_t* views) {
    uint32_t* test = (uint32_t*)malloc(scene->view_count * sizeof *test);
    size_t train_count = 0, test_count = 0;
    gsf_splat_split_views(scene->view_count, 8, k, views, &train_count, test, &test_count);
    free(test);
    return train_count;
}

// Two parallel walls in front of a camera: the first and smaller one hides the middle of the second. The track of one
// more point proves it visible, although no ray reaches it.
static void test_walls(void) {
    enum { SIDE = 30, WALL_POINTS = SIDE * SIDE, COUNT = 2 * WALL_POINTS + 3 };
    double* points = (double*)malloc(COUNT * 3 * sizeof *points);
    uint8_t* colors = (uint8_t*)calloc(COUNT, 3);
    size_t* begin = (size_t*)calloc(COUNT + 1, sizeof *begin);
    uint64_t state = 5;
    const double shift[3] = {3.2e6, -1.1e6, 250.0}; // georeferenced
    for (size_t i = 0; i < 2 * WALL_POINTS; i++) {
        const size_t at = i % WALL_POINTS;
        // the first wall covers half the width of the second
        const double z = i < WALL_POINTS ? 2.0 : 4.0, size = i < WALL_POINTS ? 0.8 : 3.2;
        points[3 * i] = size * ((double)(at % SIDE) / (SIDE - 1) - 0.5) + test_random_in(&state, -0.002, 0.002);
        points[3 * i + 1] = size * ((double)(at / SIDE) / (SIDE - 1) - 0.5) + test_random_in(&state, -0.002, 0.002);
        points[3 * i + 2] = z + test_random_in(&state, -0.004, 0.004);
    }
    // behind the first wall; behind the camera; outside the image
    const double others[9] = {0.0, 0.0, 3.0, 0.0, 0.0, -1.0, 9.0, 0.0, 3.0};
    memcpy(points + 6 * WALL_POINTS, others, sizeof others);
    for (size_t i = 0; i < COUNT; i++)
        for (size_t k = 0; k < 3; k++) points[3 * i + k] += shift[k];
    uint32_t track[1] = {1};
    begin[COUNT] = 1; // the last point, which no ray reaches, is in view 1's track
    gsf_scene_view views[2];
    memset(views, 0, sizeof views);
    for (int v = 0; v < 2; v++) {
        gsf_camera* c = &views[v].camera;
        for (int k = 0; k < 4; k++) c->w2c[5 * k] = 1.0;
        for (int k = 0; k < 3; k++) c->w2c[12 + k] = -shift[k];
        c->fx = c->fy = 100.0;
        c->cx = c->cy = 60.0;
        c->width = c->height = 120;
    }
    gsf_scene scene;
    memset(&scene, 0, sizeof scene);
    scene.view_count = 2;
    scene.views = views;
    scene.point_count = COUNT;
    scene.points = points;
    scene.colors = colors;
    scene.track_begin = begin;
    scene.track_views = track;
    const uint32_t both[2] = {0, 1}, first[1] = {0}, wrong[1] = {2};
    for (int z = 0; z < 2; z++) {
        gsf_visibility_stats stats;
        uint8_t* keep = visible(&scene, first, 1, GSF_VISIBILITY_RAYS, z, &stats);
        size_t near_kept = 0, hidden = 0, hidden_kept = 0, open = 0, open_kept = 0, kept = 0;
        for (size_t i = 0; i < 2 * WALL_POINTS; i++) {
            const double x = fabs(points[3 * i] - shift[0]), y = fabs(points[3 * i + 1] - shift[1]);
            if (i < WALL_POINTS) near_kept += keep[i];
            // the first wall's shadow on the second is 0.8 wide
            else if (fmax(x, y) < 0.7) { hidden++; hidden_kept += keep[i]; }
            else if (fmax(x, y) > 0.95) { open++; open_kept += keep[i]; }
        }
        for (size_t i = 0; i < COUNT; i++) kept += keep[i];
        CHECK(near_kept == WALL_POINTS && hidden > 100 && hidden_kept == 0 && open > 100 && open_kept == open);
        CHECK(!keep[2 * WALL_POINTS] && !keep[2 * WALL_POINTS + 1] && !keep[2 * WALL_POINTS + 2]);
        CHECK(stats.points == COUNT && stats.kept == kept && stats.by_rays == kept && stats.by_tracks == 0);
        CHECK(stats.rays + stats.culled == COUNT && stats.culled >= 2);
#ifdef GSF_USE_EMBREE
        CHECK(stats.used_embree == !z);
#else
        CHECK(stats.used_embree == 0);
#endif
        uint8_t* again = visible(&scene, both, 2, GSF_VISIBILITY_BOTH, z, &stats);
        CHECK(again[2 * WALL_POINTS + 2] && stats.by_tracks == 1 && stats.kept == kept + 1);
        free(again);
        again = visible(&scene, both, 2, GSF_VISIBILITY_TRACKS, z, &stats);
        CHECK(stats.kept == 1 && stats.rays == 0 && again[2 * WALL_POINTS + 2]);
        free(again);
        again = visible(&scene, NULL, 0, GSF_VISIBILITY_BOTH, z, &stats);
        CHECK(stats.kept == 0);
        free(again);
        free(keep);
    }
    // A NaN point is not visible and changes no other result; a pile of equal points does no harm either.
    points[3 * 7] = NAN;
    for (size_t i = 20; i < 60; i++) memcpy(points + 3 * i, points + 3 * 19, 3 * sizeof(double));
    for (int z = 0; z < 2; z++) {
        uint8_t* keep = visible(&scene, first, 1, GSF_VISIBILITY_RAYS, z, NULL);
        size_t kept = 0;
        for (size_t i = 0; i < WALL_POINTS; i++) kept += keep[i];
        CHECK(kept == WALL_POINTS - 1 && !keep[7]);
        free(keep);
    }
    // One point only; bad arguments.
    uint8_t* keep = (uint8_t*)malloc(COUNT);
    scene.point_count = 1;
    CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, &scene, first, 1, NULL, keep, NULL));
    CHECK(keep[0]);
    scene.point_count = 0;
    CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, &scene, first, 1, NULL, keep, NULL));
    scene.point_count = COUNT;
    CHECK_RESULT(&ctx, gsf_splat_filter_points(&ctx, &scene, wrong, 1, NULL, keep, NULL), GSF_ERROR_INVALID_ARGUMENT);
    gsf_visibility_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.neighbours = GSF__KNN_MAX + 1;
    CHECK_RESULT(&ctx, gsf_splat_filter_points(&ctx, &scene, first, 1, &desc, keep, NULL), GSF_ERROR_INVALID_ARGUMENT);
    desc.neighbours = 0;
    desc.tolerance = NAN;
    CHECK_RESULT(&ctx, gsf_splat_filter_points(&ctx, &scene, first, 1, &desc, keep, NULL), GSF_ERROR_INVALID_ARGUMENT);
    views[0].camera.w2c[3] = NAN;
    CHECK_RESULT(&ctx, gsf_splat_filter_points(&ctx, &scene, first, 1, NULL, keep, NULL), GSF_ERROR_NUMERIC);
    free(keep);
    free(points);
    free(colors);
    free(begin);
}

// ---- the same results as testing every disc against every point -----------------

// The definition of the filter, without any search structure: keep[i], and near[i] = 1 where rounding may decide.
static void naive_visible(const gsf_scene* scene, const uint32_t* views, size_t count, const gsf_visibility_desc* options,
                          uint8_t* keep, uint8_t* beside) {
    gsf_visibility_desc desc = gsf__visibility_desc_defaults(options);
    const float tolerance = desc.tolerance, close = 1e-4f;
    gsf_visibility_stats stats;
    gsf__vis_job job;
    memset(keep, 0, scene->point_count);
    memset(beside, 0, scene->point_count);
    CHECK_OK(&ctx, gsf__vis_begin(&ctx, scene, views, count, &desc, keep, &job, &stats));
    for (size_t e = 0; e < count; e++) {
        gsf__vis_look(&ctx, &job, e);
        const gsf__look* seen_from = job.looks;
        for (size_t i = 0; i < job.discs.count; i++) {
            const size_t row = job.discs.rows[i];
            gsf__sight sight;
            if (!gsf__vis_sight(&job, seen_from->eye, i, &sight)) continue;
            const double limit = (double)gsf__vis_limit(&job, seen_from, i);
            double cover[3] = {0.0, 0.0, 0.0}; // outer two: with zero tolerance, rounding decides about discs in the plane
            for (int k = tolerance > 0.0f; k < 3 - (tolerance > 0.0f); k++) {
                desc.tolerance = tolerance + close * (float)(k - 1);
                for (size_t j = 0; j < job.discs.count; j++) {
                    const gsf__vis_disc disc = gsf__vis_disc_of(&job, seen_from->eye, j);
                    const double own = (double)job.discs.all[i].radius;
                    if (j != i) cover[k] += gsf__vis_cover(&disc, &sight, own, (double)desc.tolerance);
                }
            }
            keep[row] |= cover[1] < limit;
            beside[row] |= cover[1] > 0.0 && fabs(cover[1] - limit) < (double)close;
            if (tolerance == 0.0f) beside[row] |= (cover[0] < limit) != (cover[2] < limit);
        }
    }
    gsf__arena_free(&job.arena);
}

// Returns the number of points that rounding may decide.
static size_t check_naive(const gsf_scene* scene, const uint32_t* views, size_t count, const gsf_visibility_desc* options) {
    const size_t n = scene->point_count;
    const gsf_cpu_level level = ctx.cpu_level;
    uint8_t *keep = (uint8_t*)malloc(n), *beside = (uint8_t*)malloc(n), *found = (uint8_t*)malloc(n);
    size_t undecided = 0;
    naive_visible(scene, views, count, options, keep, beside);
    for (int way = 0; way < 3; way++) { // Embree with and without AVX2, the projected discs
        gsf_visibility_desc desc = *options;
        desc.method = GSF_VISIBILITY_RAYS;
        desc.use_zbuffer = way == 2;
        if (way == 1) ctx.cpu_level = GSF_CPU_SCALAR;
        CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, scene, views, count, &desc, found, NULL));
        ctx.cpu_level = level;
        size_t wrong = 0;
        for (size_t i = 0; i < n; i++) wrong += found[i] != keep[i] && !beside[i];
        if (!CHECK(wrong == 0)) fprintf(stderr, "  %zu of %zu points, way %d\n", wrong, n, way);
    }
    for (size_t i = 0; i < n; i++) undecided += beside[i];
    free(keep);
    free(beside);
    free(found);
    return undecided;
}

// Zero tolerance and zero coverage hide more points than the defaults, but not all; without a grazing limit, more are kept
// than with one of 0.2.
static void check_zeros(const gsf_scene* scene, const uint32_t* views, size_t count) {
    uint8_t* keep = (uint8_t*)malloc(scene->point_count);
    for (int field = 0; field < 3; field++) {
        gsf_visibility_desc desc;
        gsf_visibility_stats some, zero;
        memset(&desc, 0, sizeof desc);
        desc.method = GSF_VISIBILITY_RAYS;
        float* value = field == 0 ? &desc.tolerance : field == 1 ? &desc.coverage : &desc.min_grazing_cos;
        if (field == 2) *value = 0.2f;
        CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, scene, views, count, &desc, keep, &some));
        *value = -1.0f;
        CHECK_OK(&ctx, gsf_splat_filter_points(&ctx, scene, views, count, &desc, keep, &zero));
        CHECK(field == 2 ? zero.kept > some.kept : zero.kept < some.kept && zero.kept > 0);
        (void)check_naive(scene, views, count, &desc);
    }
    free(keep);
}

static void test_naive(void) {
    enum { SIZES = 4, VIEWS = 12 };
    static const size_t sizes[SIZES] = {9, 300, 3000, 6000};
    gsf_visibility_desc defaults;
    size_t points_met = 0, undecided = 0;
    memset(&defaults, 0, sizeof defaults);
    for (int s = 0; s < 2 * test_few(SIZES, 3); s++) { // balls one behind the other, with and without tracks
        const size_t n = sizes[s / 2];
        uint64_t state = 500 + (uint64_t)s;
        gsf_scene_view views[VIEWS];
        uint32_t chosen[VIEWS / 2];
        double* points = (double*)malloc(3 * n * sizeof(double));
        size_t* begin = (size_t*)calloc(n + 1, sizeof(size_t));
        uint32_t* track = (uint32_t*)malloc(3 * n * sizeof(uint32_t));
        memset(views, 0, sizeof views);
        for (int v = 0; v < VIEWS; v++) {
            const double angle = 0.2 * v + 0.1, up[3] = {0.0, -1.0, 0.0}, target[3] = {0.0, 0.0, 0.0};
            const double eye[3] = {4.0 * cos(angle), -1.0, 4.0 * sin(angle)}; // part of it is outside the frame
            double pose[16];
            CHECK_OK(&ctx, gsf_traj_look_at(&ctx, eye, target, up, pose));
            gsf_camera* c = &views[v].camera;
            c->fx = c->fy = 330.0;
            c->cx = 100.0;
            c->cy = 75.0;
            c->width = 200;
            c->height = 150;
            gsf_set_camera_c2w(c, pose);
            if (v % 2 == 0) chosen[v / 2] = (uint32_t)v;
        }
        for (size_t i = 0; i < n; i++) {
            double d[3], length2 = 0.0;
            for (int k = 0; k < 3; k++) {
                d[k] = test_random_in(&state, -1.0, 1.0);
                length2 += d[k] * d[k];
            }
            for (size_t k = 0; k < 3; k++)
                points[3 * i + k] = 0.6 * d[k] / sqrt(length2) + floor(test_random_in(&state, 0.0, 2.0)) * 1.3 - 0.65;
            for (int t = 0; s % 2 && t < 3; t++)
                track[begin[i + 1] + begin[i] + (size_t)t] = (uint32_t)(4 * t) + (uint32_t)test_random_in(&state, 0.0, 3.99);
            begin[i + 1] = begin[i] + (s % 2 ? 3 : 0);
        }
        gsf_scene scene;
        memset(&scene, 0, sizeof scene);
        scene.view_count = VIEWS;
        scene.views = views;
        scene.point_count = n;
        scene.points = points;
        scene.track_begin = begin;
        scene.track_views = track;
        undecided += check_naive(&scene, chosen, VIEWS / 2, &defaults);
        if (n == 300) check_zeros(&scene, chosen, VIEWS / 2);
        points_met += n;
        free(points);
        free(begin);
        free(track);
    }
    CHECK(undecided * 100 < points_met);
    printf("naive loop: same answers for %zu points, %zu left to rounding\n", points_met - undecided, undecided);
}

// ---- memory limits -------------------------------------------------------------

#if defined(__has_feature)
#if __has_feature(address_sanitizer)
#define HAVE_NO_LIMIT // AddressSanitizer's shadow memory exceeds any limit
#endif
#endif
#if defined(GSF_USE_EMBREE) && defined(__linux__) && !defined(__SANITIZE_ADDRESS__) && !defined(HAVE_NO_LIMIT)
#include <sys/resource.h>
#include <sys/wait.h>

enum { BY_EMBREE, PROJECTED, NO_MEMORY, WRONG };

static int answer_within(const gsf_scene* scene, size_t spare, const uint8_t* expected) { // in a separate process
    static const uint32_t view[1] = {0};
    gsf_context own;
    gsf_visibility_desc desc;
    gsf_visibility_stats stats;
    unsigned long pages = 0;
    struct rlimit limit;
    uint8_t* keep = (uint8_t*)malloc(scene->point_count);
    memset(&own, 0, sizeof own);
    memset(&desc, 0, sizeof desc);
    own.threads = 1;
    desc.method = GSF_VISIBILITY_RAYS;
    FILE* statm = fopen("/proc/self/statm", "r");
    if (gsf_init_context(&own) != GSF_OK || !keep || !statm || fscanf(statm, "%lu", &pages) != 1) return WRONG;
    limit.rlim_cur = limit.rlim_max = (rlim_t)pages * (rlim_t)sysconf(_SC_PAGESIZE) + spare;
    if (setrlimit(RLIMIT_AS, &limit) != 0) return WRONG;
    const gsf_result result = gsf_splat_filter_points(&own, scene, view, 1, &desc, keep, &stats);
    if (result == GSF_ERROR_OUT_OF_MEMORY) return strstr(own.error, "memory") ? NO_MEMORY : WRONG;
    if (result != GSF_OK || memcmp(keep, expected, scene->point_count) != 0) return WRONG;
    return stats.used_embree ? BY_EMBREE : PROJECTED;
}

// With any memory limit, the filter works with Embree or without it, or returns an error code. Must be called before
// OpenMP and Embree start threads, which forked processes do not inherit.
static void test_little_memory(void) {
    enum { SIDE = 100, COUNT = 2 * SIDE * SIDE };
    static double points[3 * COUNT];
    static uint8_t colors[3 * COUNT], expected[COUNT];
    static size_t no_tracks[COUNT + 1];
    gsf_scene_view view;
    gsf_scene scene;
    memset(&view, 0, sizeof view);
    memset(&scene, 0, sizeof scene);
    for (size_t i = 0; i < COUNT; i++) { // a wall that hides another wall of the same angular size
        const size_t at = i % (SIDE * SIDE);
        const double z = i < COUNT / 2 ? 2.0 : 4.0;
        points[3 * i] = 0.4 * z * ((double)(at % SIDE) / (SIDE - 1) - 0.5);
        points[3 * i + 1] = 0.4 * z * ((double)(at / SIDE) / (SIDE - 1) - 0.5);
        points[3 * i + 2] = z;
        expected[i] = i < COUNT / 2;
    }
    for (int k = 0; k < 4; k++) view.camera.w2c[5 * k] = 1.0;
    view.camera.fx = view.camera.fy = 100.0;
    view.camera.cx = view.camera.cy = 60.0;
    view.camera.width = view.camera.height = 120;
    scene.view_count = 1;
    scene.views = &view;
    scene.point_count = COUNT;
    scene.points = points;
    scene.colors = colors;
    scene.track_begin = no_tracks;
    size_t seen[4] = {0, 0, 0, 0};
    for (size_t spare = 0; spare < (size_t)256 << 20; spare += (size_t)4 << 20) {
        fflush(NULL);
        const pid_t child = fork();
        if (child == 0) {
            alarm(60);
            _exit(answer_within(&scene, spare, expected));
        }
        int status = 0;
        if (!CHECK(child > 0 && waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) < WRONG))
            fprintf(stderr, "  with %zu bytes: status %x\n", spare, (unsigned)status);
        seen[WEXITSTATUS(status) & 3]++;
    }
    printf("little memory: %zu times by Embree, %zu projected, %zu refused\n", seen[BY_EMBREE], seen[PROJECTED],
           seen[NO_MEMORY]);
    CHECK(seen[BY_EMBREE] > 0 && seen[PROJECTED] > 0 && seen[NO_MEMORY] > 0);
}
#else
static void test_little_memory(void) {}
#endif

// ---- on photos and in a procedural scene ---------------------------------------

// Of the points that COLMAP's tracks prove visible, how many do the rays find?
static void test_recall(void) {
    const char* folder = test_fox();
    if (!folder) {
        printf("the fox photos are not here (GSF_FOX): recall against their tracks skipped\n");
        return;
    }
    gsf_scene scene;
    if (!CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, folder, NULL, &scene))) return;
    uint32_t* views = (uint32_t*)malloc(scene.view_count * sizeof *views);
    for (size_t k = 3; k <= 9; k += 3)
        for (int z = 0; z < 2; z++) {
            const size_t count = training_views(&scene, k, views);
            gsf_visibility_stats stats;
            uint8_t* tracks = visible(&scene, views, count, GSF_VISIBILITY_TRACKS, 0, NULL);
            uint8_t* rays = visible(&scene, views, count, GSF_VISIBILITY_RAYS, z, &stats);
            size_t proven = 0, found = 0;
            for (size_t i = 0; i < scene.point_count; i++) {
                proven += tracks[i];
                found += tracks[i] && rays[i];
            }
            const double recall = (double)found / (double)proven;
            printf(
                "fox, K = %zu, %s: recall %.4f of the %zu points in tracks; %zu of %zu kept; normals %.3f s, build %.3f s, "
                "rays %.3f s\n",
                k, stats.used_embree ? "embree" : "projected", recall, proven, stats.kept, stats.points,
                stats.seconds_normals, stats.seconds_build, stats.seconds_rays);
            CHECK(count == k && recall >= 0.95);
            free(tracks);
            free(rays);
        }
    // The tracks of other points count as evidence, too. Points whose entire track is removed must be found as well.
    uint8_t* proven[3];
    for (size_t k = 0; k < 3; k++)
        proven[k] = visible(&scene, views, training_views(&scene, 3 * k + 3, views), GSF_VISIBILITY_TRACKS, 0, NULL);
    for (size_t i = 0, from = 0, to = 0; i <= scene.point_count; i++) {
        const size_t end = i < scene.point_count ? scene.track_begin[i + 1] : 0;
        scene.track_begin[i] = to;
        for (size_t t = from; t < end && i % 2; t++) scene.track_views[to++] = scene.track_views[t];
        from = end;
    }
    for (size_t k = 0; k < 3; k++) {
        const size_t count = training_views(&scene, 3 * k + 3, views);
        uint8_t* rays = visible(&scene, views, count, GSF_VISIBILITY_RAYS, 0, NULL);
        size_t all = 0, found = 0;
        for (size_t i = 0; i < scene.point_count; i += 2) {
            all += proven[k][i];
            found += proven[k][i] && rays[i];
        }
        printf("fox, K = %zu, every second track taken away: recall %.4f of the %zu points that had one\n", count,
               (double)found / (double)all, all);
        CHECK(all > 500 && (double)found >= 0.95 * (double)all);
        free(proven[k]);
        free(rays);
    }
    free(views);
    gsf_splat_destroy_scene(&ctx, &scene);
}

#ifdef GSF_USE_EMBREE

typedef struct accuracy { size_t shown, shown_kept, hidden, hidden_kept; } accuracy;

static double balanced(const char* what, const accuracy* a) {
    const double keep = (double)a->shown_kept / (double)a->shown, leak = (double)a->hidden_kept / (double)a->hidden;
    const double value = 0.5 * (keep + 1.0 - leak);
    printf("procedural scene, %s: keeps %.3f of %zu visible, %.3f of %zu hidden; balanced accuracy %.4f\n", what, keep,
           a->shown, leak, a->hidden, value);
    return value;
}

static void count_answers(accuracy* a, const uint8_t* kept, const uint8_t* truth, size_t points, size_t views,
                          const uint32_t* chosen, size_t count) {
    const uint8_t* outlier = truth + points * views;
    for (size_t i = 0; i < points; i++) {
        int seen = 0;
        if (outlier[i]) continue; // not on a surface of the scene
        for (size_t v = 0; v < count; v++) seen |= truth[i * views + chosen[v]] & 1;
        if (seen) { a->shown++; a->shown_kept += kept[i]; }
        else { a->hidden++; a->hidden_kept += kept[i]; }
    }
}

// Different views in random order.
static void pick_views(uint64_t stream, size_t views, size_t count, uint32_t* chosen) {
    for (uint64_t draw = 0, n = 0; n < count; draw++) {
        const uint32_t view = (uint32_t)(gsf_draw_bits(7, stream, draw) % views);
        int taken = 0;
        for (uint64_t i = 0; i < n; i++) taken |= chosen[i] == view;
        if (!taken) chosen[n++] = view;
    }
}

static void chunks_backwards(void* user, size_t count, gsf_chunk_fn fn, void* arg) {
    (void)user;
    while (count-- > 0) fn(arg, count, 0);
}

// The generator's own scene, read from its files, against the visibility that it traced. The photos and with them the
// pixel noise are smaller than by default, so that the points are equally accurate. `split` accumulates, per K, the views of
// the papers' split, `choices` random choices of as many.
static void test_procedural(uint64_t seed, accuracy split[3], accuracy choices[3]) {
    char folder[1024], path[1100], what[64];
    snprintf(folder, sizeof folder, "%s", test_scratch("procedural"));
    make_scene_options options = make_scene_defaults;
    options.width = 128;
    options.height = 96;
    options.noise *= 128.0 / 320.0;
    options.seed = seed;
    gsf_scene scene;
    size_t size = 0;
    if (!CHECK(make_scene(&ctx, &options, folder) == 0) ||
        !CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, folder, NULL, &scene))) {
        remove_scene(folder, options.views);
        return;
    }
    snprintf(path, sizeof path, "%s/truth/visibility.bin", folder);
    char* file = test_read_file(path, &size);
    const size_t n = scene.point_count, views = scene.view_count;
    const uint8_t *truth = (const uint8_t*)file + 24, *outlier = truth + n * views;
    uint64_t sizes[2];
    memcpy(sizes, file + 8, sizeof sizes);
    CHECK(memcmp(file, "GSFTRUTH", 8) == 0 && sizes[0] == n && sizes[1] == views && size == 24 + n * (views + 1));
    CHECK(n == (size_t)options.points && views == (size_t)options.views);
    size_t tracked = 0, shown = 0, outliers = 0, long_enough = 0;
    for (size_t i = 0; i < n; i++) { // tracks contain only visible points, and far from all of them
        outliers += outlier[i];
        long_enough += scene.track_begin[i + 1] - scene.track_begin[i] >= 2;
        for (size_t v = 0; v < views && !outlier[i]; v++) shown += truth[i * views + v] & 1u;
        for (size_t t = scene.track_begin[i]; t < scene.track_begin[i + 1] && !outlier[i]; t++)
            tracked += truth[i * views + scene.track_views[t]] & 1u;
        if (!outlier[i]) tracked -= scene.track_begin[i + 1] - scene.track_begin[i];
    }
    CHECK(tracked == 0 && long_enough == n && outliers > 0 && outliers < n / 50);
    CHECK(scene.track_begin[n] < shown * 3 / 4);

    uint32_t* chosen = (uint32_t*)malloc(views * sizeof *chosen);
    for (size_t k = 3; k <= 9; k += 3) {
        accuracy a;
        memset(&a, 0, sizeof a);
        const size_t count = training_views(&scene, k, chosen);
        uint8_t* rays = visible(&scene, chosen, count, GSF_VISIBILITY_RAYS, 0, NULL);
        uint8_t* projected = visible(&scene, chosen, count, GSF_VISIBILITY_RAYS, 1, NULL);
        if (k == 3) {
            const gsf_parallel parallel = ctx.parallel;
            ctx.parallel.for_fn = chunks_backwards; // one worker, the chunks in another order: the same answers
            uint8_t* again = visible(&scene, chosen, count, GSF_VISIBILITY_RAYS, 0, NULL);
            ctx.parallel = parallel;
            CHECK(memcmp(rays, again, n) == 0);
            free(again);
        }
        size_t differ = 0;
        for (size_t i = 0; i < n; i++) differ += rays[i] != projected[i];
        CHECK(differ * 1000 <= n); // both methods find the same discs
        count_answers(&a, rays, truth, n, views, chosen, count);
        count_answers(split + k / 3 - 1, rays, truth, n, views, chosen, count);
        snprintf(what, sizeof what, "seed %d, K = %zu", (int)seed, k);
        const double value = balanced(what, &a);
        if (k == 3) CHECK(value >= 0.92);
        free(rays);
        free(projected);
        for (uint64_t choice = 0; choice < CHOICES; choice++) {
            pick_views(100 * k + choice, views, k, chosen);
            uint8_t* kept = visible(&scene, chosen, k, GSF_VISIBILITY_RAYS, 0, NULL);
            count_answers(choices + k / 3 - 1, kept, truth, n, views, chosen, k);
            free(kept);
        }
    }
    accuracy pairs; // single views are harder: no second view corrects an error
    memset(&pairs, 0, sizeof pairs);
    for (uint32_t v = 0; v < views; v += 8) {
        uint8_t* rays = visible(&scene, &v, 1, GSF_VISIBILITY_RAYS, 0, NULL);
        for (size_t i = 0; i < n; i++) {
            if (outlier[i] || !(truth[i * views + v] & 2)) continue;
            if (truth[i * views + v] & 1) { pairs.shown++; pairs.shown_kept += rays[i]; }
            else { pairs.hidden++; pairs.hidden_kept += rays[i]; }
        }
        free(rays);
    }
    CHECK(balanced("single views", &pairs) >= 0.855); // the limit is tuned for the union of several views
    memset(scene.track_begin, 0, (n + 1) * sizeof *scene.track_begin);
    accuracy bare; // discs only, without tracks
    memset(&bare, 0, sizeof bare);
    const size_t count = training_views(&scene, 3, chosen);
    uint8_t* rays = visible(&scene, chosen, count, GSF_VISIBILITY_RAYS, 0, NULL);
    count_answers(&bare, rays, truth, n, views, chosen, count);
    CHECK(balanced("K = 3 without tracks", &bare) >= 0.89);
    free(rays);
    free(chosen);
    free(file);
    gsf_splat_destroy_scene(&ctx, &scene);
    remove_scene(folder, options.views);
}

static void test_accuracy(int seeds) {
    accuracy split[3], choices[3];
    char what[64];
    memset(split, 0, sizeof split);
    memset(choices, 0, sizeof choices);
    for (int seed = 1; seed <= seeds; seed++) test_procedural((uint64_t)seed, split, choices);
    for (int k = 0; k < 3 && seeds >= SEEDS; k++) {
        // With six or nine views spread over the arc, few points are hidden from all of them: 77 to 183 per seed with
        // six views, 20 to 60 with nine, so that three points change a seed's figure by up to 0.06. Hence all seeds are
        // evaluated together, and random choices of views as well, which hide more.
        snprintf(what, sizeof what, "%d seeds, K = %d", seeds, 3 * k + 3);
        CHECK(balanced(what, split + k) >= (k == 0 ? 0.93 : 0.90)); // measured: 0.943, 0.919, 0.914
        snprintf(what, sizeof what, "%d seeds, %d random choices of %d views", seeds, (int)CHOICES, 3 * k + 3);
        CHECK(balanced(what, choices + k) >= 0.91); // 0.937, 0.946, 0.918
    }
}

#endif

int main(int argc, char** argv) { // [SEEDS]: procedural scenes to trace, default 8
    const int seeds = argc > 1 ? atoi(argv[1]) : test_few(SEEDS, 2);
    memset(&ctx, 0, sizeof ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    test_little_memory();
    test_neighbours();
    test_from_points();
    test_walls();
    test_naive();
    test_recall();
#ifdef GSF_USE_EMBREE
    test_accuracy(seeds);
#else
    (void)seeds;
    printf("built without Embree: the procedural scene cannot be traced, accuracy against it skipped\n");
#endif
    return test_report();
}
