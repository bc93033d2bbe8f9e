// golden_traj.c - gsfixer_traj.h against data computed by the GSFixer release (tests/golden/traj/README.md). Every file
// in the folder that has the tensors of a scene is used; counts come from the shapes. Tolerance: 1e-9 of the largest
// value for float64 tensors, 1e-6 for float32, up to the signs of eigenvectors.
#define _DEFAULT_SOURCE 1 // opendir
#include <dirent.h>

#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h" // the train / test split
#include "test.h"

static const double tolerance = 1e-9;
static gsf_context ctx;

// ---- tensors of one file, freed together ---------------------------------------

static test_tensors file;
static test_tensor loaded[512];
static size_t loaded_count;

static const test_tensor* find(const char* name) { // NULL when absent
    for (size_t i = 0; i < loaded_count; i++)
        if (strcmp(loaded[i].name, name) == 0) return &loaded[i];
    if (loaded_count == 512) { fprintf(stderr, "too many tensors\n"); exit(2); }
    loaded[loaded_count] = test_find_tensor(&file, name);
    return loaded[loaded_count].v ? &loaded[loaded_count++] : NULL;
}

static const test_tensor* get(const char* name) {
    const test_tensor* t = find(name);
    if (!t) { fprintf(stderr, "%s: no tensor %s\n", file.path, name); exit(2); }
    return t;
}

static void close_file(void) {
    for (size_t i = 0; i < loaded_count; i++) test_free_tensor(&loaded[i]);
    loaded_count = 0;
    test_close_tensors(&file);
}

static void* take(size_t bytes) { // of exactly that size, so that a sanitizer detects any overrun
    void* memory = malloc(bytes ? bytes : 1);
    if (!memory) { fprintf(stderr, "out of memory: %zu bytes\n", bytes); exit(2); }
    return memory;
}

// (.., 3 or 4, 4) row-major to (n,16) column-major.
static double* poses_of(const test_tensor* t, size_t* count) {
    const size_t rows = t->dim[t->rank - 2], n = t->count / (4 * rows);
    double* out = (double*)take(n * 16 * sizeof(double));
    for (size_t i = 0; i < n; i++)
        for (size_t r = 0; r < 4; r++)
            for (size_t c = 0; c < 4; c++)
                out[16 * i + 4 * c + r] = r < rows ? t->v[(i * rows + r) * 4 + c] : (double)(c == 3);
    if (count) *count = n;
    return out;
}

// Compares (n,16) column-major with a tensor; D = signs of its rows (NULL: all 1).
static void compare_poses(const char* name, const double* actual, const double* signs, double tol) {
    size_t n;
    const test_tensor* t = get(name);
    double* expected = poses_of(t, &n);
    double* ours = (double*)take(n * 16 * sizeof(double));
    for (size_t i = 0; i < 16 * n; i++) ours[i] = actual[i] * (signs && i % 4 < 3 ? signs[i % 4] : 1.0);
    char what[2400];
    snprintf(what, sizeof what, "%s: %s", file.path, name);
    test_compare(what, ours, expected, 16 * n, tol * test_max_abs(expected, 16 * n));
    free(expected);
    free(ours);
}

static void compare_values(const char* name, const double* actual, size_t count, double tol) {
    const test_tensor* t = get(name);
    char what[2400];
    snprintf(what, sizeof what, "%s: %s", file.path, name);
    if (CHECK(t->count == count)) test_compare(what, actual, t->v, count, tol * test_max_abs(t->v, count));
}

// D = diag(+-1) with D * actual = expected for the rows of two transforms (column-major); also checks det D = 1.
static void find_signs(const double* actual, const double* expected, double signs[3]) {
    for (int r = 0; r < 3; r++) {
        double dot = 0.0;
        for (int c = 0; c < 3; c++) dot += actual[4 * c + r] * expected[4 * c + r];
        signs[r] = dot < 0.0 ? -1.0 : 1.0;
    }
    CHECK(signs[0] * signs[1] * signs[2] == 1.0);
}

// ---- one scene -----------------------------------------------------------------

static void check_normalisation(void) {
    size_t n;
    double* c2w = poses_of(get("c2w"), &n);
    double* w2c = poses_of(get("in.w2c"), NULL);
    double* inverse = (double*)take(n * 16 * sizeof(double));
    for (size_t i = 0; i < n; i++) gsf__mat4_rigid_inverse(w2c + 16 * i, inverse + 16 * i);
    compare_poses("c2w", inverse, NULL, tolerance);

    void* scratch = take(gsf__traj_similarity_scratch(n));
    double first[16], strict[16];
    gsf__traj_similarity_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.official = 1;
    CHECK_OK(&ctx, gsf__traj_similarity(&ctx, c2w, n, &desc, scratch, first));
    compare_poses("norm.T1_similarity", first, NULL, tolerance);
    desc.strict_scaling = 1;
    desc.center = GSF_TRAJ_CENTER_POSES;
    CHECK_OK(&ctx, gsf__traj_similarity(&ctx, c2w, n, &desc, scratch, strict));
    compare_poses("norm.T1_strict_poses", strict, NULL, tolerance);
    free(scratch);

    const test_tensor* points = get("in.points");
    const size_t m = points->dim[0];
    double* after = (double*)take(3 * m * sizeof(double));
    double* moved = (double*)take(16 * n * sizeof(double));
    gsf__traj_transform_poses(first, c2w, n, moved);
    compare_poses("norm.c2w_after_T1", moved, NULL, tolerance);
    for (size_t i = 0; i < m; i++) gsf__traj_apply(first, points->v + 3 * i, after + 3 * i);
    compare_values("norm.points_after_T1", after, 3 * m, tolerance);

    double second[16], whole[16], product[16], signs[3];
    double* expected = poses_of(get("norm.T2_pca"), NULL);
    scratch = take(gsf__traj_principal_axes_scratch(m));
    CHECK_OK(&ctx, gsf__traj_principal_axes(&ctx, after, m, scratch, second));
    free(scratch);
    find_signs(second, expected, signs);
    compare_poses("norm.T2_pca", second, signs, tolerance);

    scratch = take(gsf__traj_normalize_scratch(n, m));
    desc.strict_scaling = 0;
    desc.center = GSF_TRAJ_CENTER_FOCUS;
    CHECK_OK(&ctx, gsf__traj_normalize(&ctx, c2w, n, points->v, m, &desc, scratch, whole));
    free(scratch);
    gsf__mat4_mul(second, first, product);
    test_compare("T2 T1", whole, product, 16, tolerance * test_max_abs(product, 16));
    compare_poses("norm.transform", whole, signs, tolerance);
    gsf__traj_transform_poses(whole, c2w, n, moved);
    compare_poses("norm.c2w", moved, signs, tolerance);
    for (size_t i = 0; i < m; i++) gsf__traj_apply(whole, points->v + 3 * i, after + 3 * i);
    for (size_t i = 0; i < 3 * m; i++) after[i] *= signs[i % 3];
    compare_values("norm.points", after, 3 * m, tolerance);
    double center[3], radius;
    CHECK_OK(&ctx, gsf__traj_camera_radius(&ctx, moved, n, center, &radius));
    compare_values("norm.scene_scale", &radius, 1, tolerance);

    double back[16];
    CHECK_OK(&ctx, gsf__traj_invert_similarity(&ctx, whole, back));
    gsf__traj_transform_poses(back, moved, n, moved);
    compare_poses("c2w", moved, NULL, tolerance);
    free(expected);
    free(after);
    free(moved);
    free(inverse);
    free(w2c);
    free(c2w);
}

static void check_indices(const char* name, const uint32_t* actual, size_t count) {
    const test_tensor* t = get(name);
    if (CHECK(t->count == count))
        for (size_t i = 0; i < count; i++) CHECK((double)actual[i] == t->v[i]);
}

static void check_training_views(void) {
    const test_tensor* train = get("train.c2w");
    const size_t views = get("c2w")->dim[0];
    size_t n, train_count, test_count;
    double* c2w = poses_of(train, &n);
    double center[3], radius, focus[3], pose[16], transform[16], signs[3];
    CHECK_OK(&ctx, gsf__traj_camera_radius(&ctx, c2w, n, center, &radius));
    compare_values("train.center", center, 3, tolerance);
    radius *= 1.1;
    compare_values("train.cameras_extent", &radius, 1, tolerance);
    CHECK_OK(&ctx, gsf_traj_find_focus(&ctx, c2w, n, focus));
    compare_values("focus_point", focus, 3, tolerance);
    CHECK_OK(&ctx, gsf__traj_average_pose(&ctx, c2w, n, 1, pose));
    compare_poses("average_pose", pose, NULL, tolerance);

    double* out = (double*)take(16 * n * sizeof(double));
    CHECK_OK(&ctx, gsf__traj_recenter_poses(&ctx, c2w, n, 1, out, transform));
    compare_poses("recenter.transform", transform, NULL, tolerance);
    compare_poses("recenter.poses", out, NULL, tolerance);
    CHECK_OK(&ctx, gsf__traj_pca_poses(&ctx, c2w, n, out, transform));
    double* expected = poses_of(get("pca_transform"), NULL);
    find_signs(transform, expected, signs);
    compare_poses("pca_transform", transform, signs, tolerance);
    compare_poses("pca_poses", out, signs, tolerance);
    free(expected);

    const char* every = test_metadata(&file, "test_every");
    const size_t test_every = every ? strtoul(every, NULL, 10) : 8;
    uint32_t* train_index = (uint32_t*)take(views * sizeof(uint32_t));
    uint32_t* test_index = (uint32_t*)take(views * sizeof(uint32_t));
    gsf_splat_split_views(views, test_every, n, train_index, &train_count, test_index, &test_count);
    check_indices("split.train", train_index, train_count);
    check_indices("split.test", test_index, test_count);
    free(train_index);
    free(test_index);
    free(out);
    free(c2w);
}

static void check_interpolations(void) {
    size_t n;
    double* c2w = poses_of(get("train.c2w"), &n);
    const test_tensor* two = find("interp2.c2w");
    if (two && n >= 2) {
        gsf__traj_spline_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.frames_per_leg = (int32_t)two->dim[0];
        double* out = (double*)take(two->dim[0] * 16 * sizeof(double));
        void* scratch = take(gsf__traj_spline_path_scratch(2, &desc));
        CHECK_OK(&ctx, gsf__traj_spline_path(&ctx, c2w, 2, &desc, scratch, out));
        compare_poses("interp2.c2w", out, NULL, tolerance);
        free(scratch);
        free(out);
    }
    const test_tensor* legs = find("interp_traj3.c2w");
    if (legs && n >= 3) {
        double* out = (double*)take(legs->dim[0] * 16 * sizeof(double));
        CHECK_OK(&ctx, gsf__traj_leg_path(&ctx, c2w, 3, (int32_t)(legs->dim[0] - 1) / 2 + 1, 1, out));
        compare_poses("interp_traj3.c2w", out, NULL, tolerance);
        free(out);
    }
    const test_tensor* glide = find("slerp_path.c2w20");
    if (glide && n >= 2) {
        double* out = (double*)take(glide->dim[0] * 16 * sizeof(double));
        void* scratch = take(gsf__traj_slerp_path_scratch(n));
        CHECK_OK(&ctx,
                 gsf__traj_slerp_path(&ctx, c2w, n, (int32_t)glide->dim[0], get("slerp_path.trans")->v[0], scratch,
                                           out));
        compare_poses("slerp_path.c2w20", out, NULL, tolerance);
        free(scratch);
        free(out);
    }
    free(c2w);
}

static const test_tensor* get_round(int round, const char* name, int needed) {
    char text[128];
    snprintf(text, sizeof text, "round%d.%s", round, name);
    return needed ? get(text) : find(text);
}

// The released windows through the function that the repair loop calls.
static void check_windows(int round, const double* c2w, size_t n, const gsf_traj_ellipse_desc* ellipse) {
    const test_tensor* windows = get_round(round, "window_c2w", 1);
    const test_tensor* nearest = get_round(round, "ref_index_first_last", 1);
    const test_tensor* loop = get_round(round, "ellipse_c2w", 1);
    const size_t count = windows->dim[0], length = windows->dim[1];
    const int32_t middle = (int32_t)length / 3 + 1;
    int32_t found = 0;
    int32_t* starts = (int32_t*)take(count * sizeof(int32_t));
    int32_t* overlaps = (int32_t*)take(count * sizeof(int32_t));
    CHECK_OK(&ctx, gsf__traj_official_windows(&ctx, (int32_t)loop->dim[0], middle, NULL, NULL, &found));
    if (!CHECK((size_t)found == count)) { free(starts); free(overlaps); return; }
    CHECK_OK(&ctx, gsf__traj_official_windows(&ctx, (int32_t)loop->dim[0], middle, starts, overlaps, &found));
    double* poses = poses_of(loop, NULL);
    double* scores = (double*)take(n * sizeof(double));
    for (size_t w = 0; w < count; w++) {
        CHECK(starts[w] == get_round(round, "window_start", 1)->v[w]);
        CHECK(overlaps[w] == get_round(round, "window_overlap", 1)->v[w]);
        for (int last = 0; last < 2; last++) {
            const double* pose = poses + 16 * (starts[w] + (last ? middle - 1 : 0));
            const test_tensor* expected = get_round(round, last ? "ref_scores_last" : "ref_scores_first", 1);
            int32_t index;
            CHECK_OK(&ctx, gsf__traj_nearest_view(&ctx, pose, c2w, n, 0.5, &index, scores));
            CHECK(index == nearest->v[2 * w + (size_t)last]);
            const double most = test_max_abs(expected->v, expected->count);
            test_compare("scores", scores, expected->v + n * w, n, tolerance * most);
        }
    }

    gsf_camera* cameras = (gsf_camera*)take(n * sizeof(gsf_camera));
    for (size_t i = 0; i < n; i++) {
        gsf_camera camera = {{0}, 500.0, 500.0, 320.0, 240.0, 640, 480};
        gsf_set_camera_c2w(&camera, c2w + 16 * i);
        cameras[i] = camera;
    }
    double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    gsf_traj_path_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.official = 1;
    desc.window_length = (int32_t)length;
    desc.ellipse_poses = (int32_t)loop->dim[0];
    desc.transform = identity; // train.c2w is normalised
    desc.ellipse = ellipse;
    gsf_traj_path_info layout;
    CHECK_OK(&ctx, gsf_traj_query_path(&ctx, n, &desc, &layout));
    if (CHECK(layout.frame_count == count * length && (size_t)layout.window_count == count)) {
        gsf_camera* path = (gsf_camera*)take(layout.frame_count * sizeof(gsf_camera));
        int32_t* reference = (int32_t*)take(layout.frame_count * sizeof(int32_t));
        double* actual = (double*)take(layout.frame_count * 16 * sizeof(double));
        void* scratch = take(layout.scratch_bytes);
        CHECK_OK(&ctx, gsf_traj_sample_path(&ctx, cameras, n, &desc, scratch, path, reference));
        for (size_t f = 0; f < layout.frame_count; f++) {
            gsf_get_camera_c2w(&path[f], actual + 16 * f);
            const int at_end = f % length == 0 || f % length == length - 1;
            CHECK(reference[f] == (at_end ? nearest->v[2 * (f / length) + (f % length != 0)] : -1.0));
        }
        char name[64];
        snprintf(name, sizeof name, "round%d.window_c2w", round);
        compare_poses(name, actual, NULL, tolerance);
        free(scratch);
        free(actual);
        free(reference);
        free(path);
    }
    free(cameras);
    free(scores);
    free(poses);
    free(starts);
    free(overlaps);
}

static int check_round(int round) { // 1 if the file has this round
    const test_tensor* loop = get_round(round, "ellipse_c2w", 0);
    if (!loop) return 0;
    size_t n;
    double* c2w = poses_of(get("train.c2w"), &n);
    double* out = (double*)take(loop->dim[0] * 16 * sizeof(double));
    void* scratch = take(gsf__traj_ellipse_scratch(n));
    gsf_traj_ellipse_desc desc = gsf__traj_round_ellipse(round, 0, (int32_t)loop->dim[0]);
    CHECK_NEAR(desc.z_variation, get_round(round, "z_variation", 1)->v[0], 1e-12);
    CHECK(desc.z_phase >= 0.0 && desc.z_phase < 1.0);
    desc.z_phase = get_round(round, "z_phase", 1)->v[0];
    CHECK_OK(&ctx, gsf__traj_ellipse_path(&ctx, c2w, n, &desc, scratch, out));
    char name[64];
    snprintf(name, sizeof name, "round%d.ellipse_c2w", round);
    compare_poses(name, out, NULL, tolerance);
    if (get_round(round, "window_c2w", 0)) check_windows(round, c2w, n, &desc);
    free(scratch);
    free(out);
    free(c2w);
    return 1;
}

static void check_scene(void) {
    check_normalisation();
    check_training_views();
    check_interpolations();
    int rounds = 0;
    for (int round = 0; round < 64; round++) rounds += check_round(round);
    CHECK(rounds > 0);
}

// ---- camera matrices and tables ------------------------------------------------

// The fields of view through the loader that reads them, the matrix of the full projection against gsf_project_point.
static void check_camera(const gsf_camera* camera, const double fov[2], const test_tensor* full) {
    char text[512];
    gsf_scene scene;
    const int n = snprintf(text, sizeof text,
                           "{\"w\":%d,\"h\":%d,\"camera_angle_x\":%.17g,\"camera_angle_y\":%.17g,\"frames\":[{\"file_path\":\"a.png\","
                           "\"transform_matrix\":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}",
                           (int)camera->width, (int)camera->height, fov[0], fov[1]);
    const gsf_bytes json = {text, (size_t)n, NULL};
    if (CHECK_OK(&ctx, gsf_splat_parse_transforms(&ctx, &json, &scene)) && CHECK(scene.view_count == 1)) {
        CHECK_NEAR(scene.views[0].camera.fx, camera->fx, tolerance * camera->fx);
        CHECK_NEAR(scene.views[0].camera.fy, camera->fy, tolerance * camera->fy);
    }
    gsf_splat_destroy_scene(&ctx, &scene);
    double c2w[16];
    gsf_get_camera_c2w(camera, c2w);
    for (int i = 0; i < 27; i++) { // points in front of the camera; stored transposed and row-major, which is column-major
        const double ray[3] = {0.4 * (i % 3 - 1), 0.3 * (i / 3 % 3 - 1), 1.0}, distance = 1.0 + 2.0 * (i / 9);
        double p[3], clip[4], u, v, depth;
        for (int r = 0; r < 3; r++)
            p[r] = c2w[12 + r] + distance * (c2w[r] * ray[0] + c2w[4 + r] * ray[1] + c2w[8 + r] * ray[2]);
        for (int r = 0; r < 4; r++)
            clip[r] = full->v[r] * p[0] + full->v[4 + r] * p[1] + full->v[8 + r] * p[2] + full->v[12 + r];
        if (!CHECK(gsf_project_point(camera, p, &u, &v, &depth))) continue;
        CHECK_NEAR((clip[0] / clip[3] + 1.0) * 0.5, u / camera->width, 3e-6);
        CHECK_NEAR((clip[1] / clip[3] + 1.0) * 0.5, v / camera->height, 3e-6);
        CHECK_NEAR(clip[3], depth, 3e-6 * depth);
    }
}

static void check_cameras(void) {
    char name[64];
    int camera_count = 0;
    for (;; camera_count++) {
        snprintf(name, sizeof name, "cam%d.K", camera_count);
        const test_tensor* K = find(name);
        if (!K) break;
        snprintf(name, sizeof name, "cam%d.size_wh", camera_count);
        const test_tensor* size = get(name);
        gsf_camera camera = {{0}, K->v[0], K->v[4], K->v[2], K->v[5], (int32_t)size->v[0], (int32_t)size->v[1]};
        snprintf(name, sizeof name, "cam%d.w2c", camera_count);
        double* w2c = poses_of(get(name), NULL);
        memcpy(camera.w2c, w2c, sizeof camera.w2c);
        free(w2c);
        snprintf(name, sizeof name, "cam%d.world_view_transform_T", camera_count); // likewise
        compare_values(name, camera.w2c, 16, 1e-6);
        snprintf(name, sizeof name, "cam%d.fov_xy", camera_count);
        const test_tensor* fov = get(name);
        snprintf(name, sizeof name, "cam%d.full_proj_T", camera_count);
        if (CHECK(fov->count == 2)) check_camera(&camera, fov->v, get(name));
    }
    CHECK(camera_count > 0);
}

static gsf_json tables;

static const gsf_json_value* member(const gsf_json_value* object, const char* key) {
    const gsf_json_value* value = gsf_find_json_member(&tables, object, key);
    if (!value) { fprintf(stderr, "tables.json: no %s\n", key); exit(2); }
    return value;
}
static double number(const gsf_json_value* object, const char* key) { return member(object, key)->number; }
static const gsf_json_value* first_of(const gsf_json_value* v) { return v->child ? &tables.values[v->child] : NULL; }
static const gsf_json_value* next_of(const gsf_json_value* v) { return v->next ? &tables.values[v->next] : NULL; }

static void check_split_table(const gsf_json_value* row) {
    const size_t n = (size_t)number(row, "n");
    uint32_t* train = (uint32_t*)take((n + 64) * sizeof(uint32_t));
    uint32_t* test = (uint32_t*)take((n + 64) * sizeof(uint32_t));
    size_t train_count, test_count;
    gsf_splat_split_views(n, (size_t)number(row, "test_every"), (size_t)number(row, "K"), train, &train_count, test,
                          &test_count);
    CHECK((double)train_count == number(row, "n_train"));
    CHECK((double)test_count == number(row, "n_test"));
    const gsf_json_value* expected = member(row, "train");
    size_t at = 0;
    for (const gsf_json_value* v = first_of(expected); v && at < train_count; v = next_of(v))
        CHECK((double)train[at++] == v->number);
    const gsf_json_value* ends = member(row, "test_first_last");
    const gsf_json_value *head = gsf_find_json_element(&tables, ends, 0), *tail = gsf_find_json_element(&tables, ends,
                                                                                                        1);
    if (CHECK(test_count && head && tail)) {
        CHECK((double)test[0] == head->number);
        CHECK((double)test[test_count - 1] == tail->number);
    }
    free(train);
    free(test);
}

static void check_window_table(const gsf_json_value* row) {
    const int32_t total = (int32_t)number(row, "total"), middle = (int32_t)number(row, "num_frames") / 3 + 1;
    const gsf_json_value *starts = member(row, "starts"), *overlaps = member(row, "overlaps");
    int32_t count = 0, *a, *b;
    CHECK_OK(&ctx, gsf__traj_official_windows(&ctx, total, middle, NULL, NULL, &count));
    if (!CHECK((uint32_t)count == starts->count && starts->count == overlaps->count)) return;
    a = (int32_t*)take((size_t)count * sizeof(int32_t));
    b = (int32_t*)take((size_t)count * sizeof(int32_t));
    CHECK_OK(&ctx, gsf__traj_official_windows(&ctx, total, middle, a, b, &count));
    int32_t at = 0;
    for (const gsf_json_value* v = first_of(starts); v; v = next_of(v)) CHECK(a[at++] == v->number);
    at = 0;
    for (const gsf_json_value* v = first_of(overlaps); v; v = next_of(v)) CHECK(b[at++] == v->number);
    free(a);
    free(b);
}

static void check_tables(void) {
    size_t size;
    char* text = test_read_file(test_golden("traj/tables.json"), &size);
    CHECK_OK(&ctx, gsf_parse_json(&ctx, "tables.json", text, size, &tables));
    const gsf_json_value* root = &tables.values[0];
    for (const gsf_json_value* v = first_of(member(root, "splits")); v; v = next_of(v)) check_split_table(v);
    for (const gsf_json_value* v = first_of(member(root, "overlap_windows")); v; v = next_of(v)) check_window_table(v);

    const gsf_json_value* weight = member(root, "reg_weight");
    for (const gsf_json_value* v = first_of(member(weight, "values")); v; v = next_of(v))
        CHECK_NEAR(gsf_traj_query_generative_weight(strtol(v->key, NULL, 10), (int64_t)number(weight, "start"),
                                                    (int64_t)number(weight, "until"), number(weight, "lambda_reg"), 1),
                   v->number, tolerance);
    for (const gsf_json_value* v = first_of(member(root, "sample_steps")); v; v = next_of(v)) {
        long start, every, until; // from the key "script (7000,10000,30000)"; the list also has iteration 0
        const char* numbers = strchr(v->key, '(');
        if (!CHECK(numbers && sscanf(numbers, "(%ld,%ld,%ld)", &start, &every, &until) == 3)) continue;
        const long count = (until - start) / every + 1, last = start + (count - 1) * every;
        if (!CHECK((size_t)count + 1 == v->count)) continue;
        const gsf_json_value* expected = first_of(v);
        CHECK(expected->number == 0.0);
        for (int32_t i = 0; i < count && (expected = next_of(expected)) != NULL; i++)
            CHECK(gsf_traj_query_repair_round((int32_t)start, (int32_t)last, (int32_t)count, i) == expected->number);
    }
    gsf_destroy_json(&ctx, &tables);
    free(text);
}

int main(void) {
    test_context_init(&ctx);
    const char* folder = test_golden("traj");
    DIR* listing = opendir(folder);
    if (!listing) { fprintf(stderr, "%s: cannot be opened\n", folder); return 2; }
    int scenes = 0, cameras = 0;
    for (struct dirent* entry; (entry = readdir(listing)) != NULL;) {
        const char* extension = strrchr(entry->d_name, '.');
        if (!extension || strcmp(extension, ".safetensors") != 0) continue;
        char path[512];
        snprintf(path, sizeof path, "traj/%s", entry->d_name);
        file = test_open_tensors(test_golden(path));
        if (find("norm.T1_similarity")) {
            check_scene();
            scenes++;
        } else if (find("cam0.K")) {
            check_cameras();
            cameras++;
        }
        close_file();
    }
    closedir(listing);
    CHECK(scenes > 0 && cameras > 0);
    check_tables();
    return test_report();
}
