// Neighbours, initial splats from points, visible-point filter.
// gcc -O2 -std=c11 -I. -Itests -DGSF_USE_EMBREE tests/test_visibility.c -lembree3 -lm
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"

#include "test.h"

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

// Every query against brute force: same distances bit for bit, places that have these distances, no place twice.
static void check_neighbours(int kind, size_t count, int k) {
    double* points = (double*)malloc((count + 1) * 3 * sizeof(double));
    double* brute = (double*)malloc((count + 1) * sizeof(double));
    make_cloud(kind, count, points);
    gsf__knn_tree tree;
    CHECK_OK(&ctx, gsf__knn_build(&ctx, points, count, NULL, &tree));
    CHECK(tree.count == count);
    int wrong_count = 0, wrong_distance = 0, wrong_place = 0;
    for (size_t i = 0; i < count; i++) {
        double distance2[GSF__KNN_MAX];
        size_t places[GSF__KNN_MAX];
        const double* q = tree.points + 3 * i;
        const int found = gsf__knn_query(&tree, q, i, k, distance2, places);
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
    gsf__knn_destroy(&ctx, &tree);
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

    // No cloud costs much more than another: nested clusters, piles of equal points, a line.
    const size_t many = 100000;
    double* points = (double*)malloc(many * 3 * sizeof(double));
    for (int kind = 0; kind < CLOUD_KINDS; kind++) {
        make_cloud(kind, many, points);
        const double start = gsf__vis_seconds();
        gsf__knn_tree tree;
        CHECK_OK(&ctx, gsf__knn_build(&ctx, points, many, NULL, &tree));
        const double built = gsf__vis_seconds();
        double sum = 0.0;
        for (size_t i = 0; i < many; i++) {
            double distance2[12];
            size_t places[12];
            const int found = gsf__knn_query(&tree, tree.points + 3 * i, i, 12, distance2, places);
            sum += found == 12 ? distance2[11] : NAN;
        }
        CHECK(isfinite(sum));
        printf("neighbours: cloud %d, %zu points: tree %.2f s, 12 nearest of all %.2f s\n", kind, many, built - start,
               gsf__vis_seconds() - built);
        gsf__knn_destroy(&ctx, &tree);
    }
    free(points);

    // Points with a non-finite coordinate and points not kept are left out.
    double few[12] = {0, 0, 0, 1, NAN, 0, 0, 2, 0, 5, 5, INFINITY};
    const uint8_t keep[4] = {1, 1, 1, 1};
    gsf__knn_tree tree;
    CHECK_OK(&ctx, gsf__knn_build(&ctx, few, 4, keep, &tree));
    CHECK(tree.count == 2);
    gsf__knn_destroy(&ctx, &tree);
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
    if (CHECK_OK(&ctx, gsf_splat_from_points(&ctx, points.v, bytes, n, NULL, 3, NULL, &splats)) &&
        CHECK(splats.count == n)) {
        test_compare_floats("means", splats.means, xyz.v, xyz.count, 1e-5);
        test_compare_floats("log_scales", splats.log_scales, scaling.v, scaling.count, 1e-5);
        test_compare_floats("quats", splats.quats, rotation.v, rotation.count, 1e-5);
        test_compare_floats("opacity_logits", splats.opacity_logits, opacity.v, opacity.count, 1e-5);
        for (size_t i = 0; i < n; i++)
            for (size_t c = 0; c < 3; c++) { // the file's colours are floats: compare after moving them onto the bytes
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
    if (CHECK_OK(&ctx, gsf_splat_from_points(&ctx, moved, bytes, n, keep, 1, origin, &splats))) {
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
        CHECK_OK(&ctx, gsf_splat_from_points(&ctx, points.v, bytes, few, NULL, 0, NULL, &splats));
        CHECK(splats.count == few);
        for (size_t i = 0; i < few; i++) CHECK(isfinite(splats.log_scales[3 * i]));
        gsf_splat_destroy(&ctx, &splats);
    }
    CHECK_RESULT(&ctx, gsf_splat_from_points(&ctx, points.v, bytes, n, NULL, 4, NULL, &splats),
                 GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(&ctx, gsf_splat_from_points(&ctx, NULL, bytes, n, NULL, 0, NULL, &splats), GSF_ERROR_INVALID_ARGUMENT);
    free(keep);
    free(moved);
    free(bytes);
    test_free_tensor(&points); test_free_tensor(&colors); test_free_tensor(&xyz); test_free_tensor(&scaling);
    test_free_tensor(&rotation); test_free_tensor(&opacity); test_free_tensor(&dc); test_free_tensor(&rest);
    test_close_tensors(&file);
}

int main(void) {
    memset(&ctx, 0, sizeof ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    test_neighbours();
    test_from_points();
    return test_report();
}
