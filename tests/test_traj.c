// test_traj.c - gsfixer_traj.h beyond the golden data: any number of views, window lengths, seeds; moved and scaled
// scenes; degenerate and non-finite input; scratch memory of exactly the queried size (so that a sanitizer detects
// overruns).
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_traj.h"
#include "test.h"

static gsf_context ctx;
static uint64_t rng = 1;

static double uniform(double lo, double hi) { return test_random_in(&rng, lo, hi); }

static void* allocate(size_t bytes) { // exact
    void* memory = malloc(bytes ? bytes : 1);
    if (!memory) { fprintf(stderr, "out of memory\n"); exit(2); }
    return memory;
}

// ---- scenes --------------------------------------------------------------------

enum { CURVE_POINTS = 60 };

typedef struct curve_scene {
    size_t count;
    gsf_camera cameras[32];
    double points[3 * CURVE_POINTS];
} curve_scene;

static gsf_camera camera_at(const double pose[16]) {
    gsf_camera camera = {{0}, 500.0, 510.0, 320.0, 230.0, 640, 480};
    gsf_set_camera_c2w(&camera, pose);
    return camera;
}

// Views of about unit distance that look near the origin, from an arc or from anywhere, and a flat cloud of points.
static void make_curve_scene(curve_scene* s, size_t count) {
    memset(s, 0, sizeof *s);
    s->count = count;
    const double up[3] = {uniform(-0.3, 0.3), 1.0, uniform(-0.3, 0.3)}, arc = uniform(1.0, 6.0);
    for (size_t i = 0; i < count; i++) {
        const double angle = arc * ((double)i + uniform(0.0, 0.8)) / (double)count, r = uniform(0.8, 1.4);
        const double eye[3] = {r * cos(angle), uniform(-0.2, 0.6), r * sin(angle)};
        const double target[3] = {uniform(-0.2, 0.2), uniform(-0.2, 0.2), uniform(-0.2, 0.2)};
        double pose[16];
        CHECK_OK(&ctx, gsf_traj_look_at(&ctx, eye, target, up, pose));
        s->cameras[i] = camera_at(pose);
    }
    for (int i = 0; i < 3 * CURVE_POINTS; i++) s->points[i] = uniform(-1.0, 1.0) * (i % 3 == 1 ? 0.2 : i % 3 ? 0.6 : 1.0);
}

static void move_scene(const curve_scene* s, double scale, const double offset[3], curve_scene* out) {
    *out = *s;
    for (size_t i = 0; i < s->count; i++) {
        double pose[16];
        gsf_get_camera_c2w(&s->cameras[i], pose);
        for (int k = 0; k < 3; k++) pose[12 + k] = pose[12 + k] * scale + offset[k];
        gsf_set_camera_c2w(&out->cameras[i], pose);
    }
    for (int i = 0; i < 3 * CURVE_POINTS; i++) out->points[i] = s->points[i] * scale + offset[i % 3];
}

typedef struct path { // result of one call in memory of exactly the promised size
    gsf_result result;
    gsf_traj_path_info layout;
    gsf_camera* frames;
    int32_t* reference;
} path;

static path sample(const gsf_camera* cameras, size_t count, const gsf_traj_path_desc* desc) {
    path p;
    memset(&p, 0, sizeof p);
    p.result = gsf_traj_query_path(&ctx, count, desc, &p.layout);
    if (p.result != GSF_OK) return p;
    p.frames = (gsf_camera*)allocate(p.layout.frame_count * sizeof(gsf_camera));
    p.reference = (int32_t*)allocate(p.layout.frame_count * sizeof(int32_t));
    void* scratch = allocate(p.layout.scratch_bytes);
    memset(scratch, 0xff, p.layout.scratch_bytes); // NaN
    memset(p.frames, 0xff, p.layout.frame_count * sizeof(gsf_camera));
    p.result = gsf_traj_sample_path(&ctx, cameras, count, desc, scratch, p.frames, p.reference);
    free(scratch);
    return p;
}
static void drop(path* p) {
    free(p->frames);
    free(p->reference);
    memset(p, 0, sizeof *p);
}

static double rigidity(const double m[16]) { // largest entry of R^T R - I; infinite when something is not finite
    double worst = 0.0;
    for (int i = 0; i < 16; i++)
        if (!isfinite(m[i])) return INFINITY;
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) {
            const double* c = m + 4 * b;
            const double e = fabs(m[4 * a] * c[0] + m[4 * a + 1] * c[1] + m[4 * a + 2] * c[2] - (a == b));
            if (e > worst) worst = e;
        }
    return worst;
}

// Frames of a path that succeeded are cameras; those of one that failed are zero. Never NaN.
static void check_frames(const path* p) {
    double worst = 0.0;
    int wrong = 0;
    for (size_t f = 0; f < p->layout.frame_count && p->frames; f++) {
        const gsf_camera* camera = &p->frames[f];
        if (p->result != GSF_OK) {
            for (int i = 0; i < 16; i++) wrong += camera->w2c[i] != 0.0;
            continue;
        }
        const double e = rigidity(camera->w2c);
        if (!(e <= worst)) worst = e;
        wrong += gsf_check_camera(&ctx, camera) != GSF_OK;
    }
    CHECK(wrong == 0);
    CHECK(worst <= 1e-12);
}

static double pose_distance(const gsf_camera* a, const gsf_camera* b) { // largest difference of pose entries
    double x[16], y[16], worst = 0.0;
    gsf_get_camera_c2w(a, x);
    gsf_get_camera_c2w(b, y);
    for (int i = 0; i < 16; i++)
        if (!(fabs(x[i] - y[i]) <= worst)) worst = fabs(x[i] - y[i]);
    return worst;
}

// ---- all sizes -----------------------------------------------------------------

static void check_reference_windows(const curve_scene* s, const path* p, int official) {
    const int32_t length = p->layout.window_length;
    int32_t side, middle;
    gsf__traj_split_window(length, &side, &middle);
    CHECK(side >= 1 && middle >= 0 && 2 * side + middle == length);
    int wrong = 0, uneven = 0, twice = 0;
    for (int32_t w = 0; w < p->layout.window_count; w++) {
        const gsf_camera* frames = p->frames + (size_t)w * (size_t)length;
        const int32_t* reference = p->reference + (size_t)w * (size_t)length;
        for (int32_t f = 0; f < length; f++) {
            const int end = f == 0 || f == length - 1;
            if (!end) wrong += reference[f] != -1;
            else if (reference[f] < 0 || (size_t)reference[f] >= s->count) wrong++;
            else wrong += memcmp(frames[f].w2c, s->cameras[reference[f]].w2c, sizeof frames[f].w2c) != 0;
            if (f > 0 && length > 2) twice += pose_distance(&frames[f - 1], &frames[f]) < 1e-12;
        }
        for (int32_t f = 1; f < side && !official; f++) { // equal steps of position on both legs
            double a[3], b[3], c[3];
            for (int leg = 0; leg < 2; leg++) {
                const gsf_camera* at = frames + (leg ? length - 1 - f : f);
                gsf_get_camera_center(at - 1, a);
                gsf_get_camera_center(at, b);
                gsf_get_camera_center(at + 1, c);
                for (int i = 0; i < 3; i++) uneven += !(fabs(a[i] - 2.0 * b[i] + c[i]) < 1e-10);
            }
        }
        // the seams of the GSFixer release
        if (official) CHECK(pose_distance(&frames[side - 1], &frames[side]) < 1e-12);
        if (official) CHECK(pose_distance(&frames[side + middle - 1], &frames[side + middle]) < 1e-12);
    }
    CHECK(wrong == 0);
    CHECK(uneven == 0);
    if (!official) CHECK(twice == 0);
}

static void test_all_sizes(void) {
    for (size_t count = 1; count <= 20; count++)
        for (int32_t length = 2; length <= 100; length++) {
            curve_scene s;
            make_curve_scene(&s, count);
            gsf_traj_path_desc desc;
            memset(&desc, 0, sizeof desc);
            desc.kind = (gsf_traj_kind)(test_random_bits(&rng) % 4);
            desc.window_length = length;
            desc.seed = test_random_bits(&rng);
            desc.round = (int32_t)(test_random_bits(&rng) % 8);
            if (test_random_bits(&rng) % 2) { desc.points = s.points; desc.point_count = CURVE_POINTS; }
            desc.official = desc.kind == GSF_TRAJ_REFERENCE && length % 3 == 1 && length >= 7 && length < 85 &&
                            test_random_bits(&rng) % 2;
            if (!desc.official && test_random_bits(&rng) % 2) {
                desc.window_count = 1 + (int32_t)(test_random_bits(&rng) % 9);
                desc.ellipse_poses = length + (int32_t)(test_random_bits(&rng) % 200);
            }
            path p = sample(s.cameras, s.count, &desc);
            check_frames(&p);
            if (count == 1) {
                CHECK(p.result == GSF_ERROR_DEGENERATE);
            } else if (CHECK_OK(&ctx, p.result) && desc.kind == GSF_TRAJ_REFERENCE) {
                check_reference_windows(&s, &p, desc.official);
            } else if (p.result == GSF_OK) {
                for (size_t f = 0; f < p.layout.frame_count; f++) {
                    const int32_t r = p.reference[f];
                    CHECK(desc.kind != GSF_TRAJ_INTERPOLATE ? r == -1 : r >= -1 && r < (int32_t)count);
                    if (r >= 0) CHECK(memcmp(p.frames[f].w2c, s.cameras[r].w2c, sizeof p.frames[f].w2c) == 0);
                }
                if (desc.kind == GSF_TRAJ_INTERPOLATE) { // starts at the first camera and ends at the last
                    CHECK(p.reference[0] == 0);
                    CHECK(p.reference[p.layout.frame_count - 1] == (int32_t)count - 1);
                }
            }
            drop(&p);
        }
}

static void test_defaults(void) {
    curve_scene s;
    make_curve_scene(&s, 6);
    gsf_traj_path_info layout;
    CHECK_OK(&ctx, gsf_traj_query_path(&ctx, 6, NULL, &layout));
    CHECK(layout.window_count == 7 && layout.window_length == 49);
    CHECK(layout.ellipse_poses == 85 && layout.frame_count == 343);
    path a = sample(s.cameras, s.count, NULL);
    CHECK_OK(&ctx, a.result);
    // windows go round the loop: their middles cover it, and none repeats another
    for (int w = 1; w < 7 && a.result == GSF_OK; w++)
        CHECK(pose_distance(&a.frames[24], &a.frames[49 * w + 24]) > 0.05);
    gsf_traj_path_desc desc;
    memset(&desc, 0, sizeof desc);
    path b = sample(s.cameras, s.count, &desc); // the same bits again, and with another seed another height
    CHECK(b.result == GSF_OK && memcmp(a.frames, b.frames, a.layout.frame_count * sizeof *a.frames) == 0);
    drop(&b);
    desc.seed = 5;
    b = sample(s.cameras, s.count, &desc);
    CHECK(b.result == GSF_OK && pose_distance(&a.frames[24], &b.frames[24]) > 1e-3);
    drop(&b);
    // frames have one size; a photo's frame has the photo's intrinsics, also when they differ
    desc.seed = 0;
    s.cameras[2].fx = 700.0;
    s.cameras[2].width = 1280;
    gsf_camera wanted = s.cameras[0];
    wanted.width = 320;
    desc.intrinsics = &wanted;
    b = sample(s.cameras, s.count, &desc);
    CHECK_OK(&ctx, b.result);
    for (size_t f = 0; f < b.layout.frame_count && b.result == GSF_OK; f++) {
        const int32_t r = b.reference[f];
        CHECK(b.frames[f].width == 320 && b.frames[f].height == 480);
        CHECK_NEAR(b.frames[f].fx, r < 0 ? wanted.fx : s.cameras[r].fx * 320.0 / s.cameras[r].width, 1e-12);
    }
    drop(&b);
    drop(&a);
    const int32_t wrong[][3] = {{1, 0, 0}, {-1, 0, 0}, {0, -1, 0}, {0, 0, -1}, {INT32_MAX, INT32_MAX, 0}};
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++) {
        memset(&desc, 0, sizeof desc);
        desc.window_length = wrong[i][0];
        desc.window_count = wrong[i][1];
        desc.ellipse_poses = wrong[i][2];
        CHECK_RESULT(&ctx, gsf_traj_query_path(&ctx, 6, &desc, &layout), GSF_ERROR_INVALID_ARGUMENT);
        CHECK(layout.frame_count == 0);
    }
    memset(&desc, 0, sizeof desc);
    desc.official = 1;
    desc.window_length = 50; // not 3n + 1
    CHECK_RESULT(&ctx, gsf_traj_query_path(&ctx, 6, &desc, &layout), GSF_ERROR_INVALID_ARGUMENT);
    desc.window_length = 49;
    desc.ellipse_poses = 16; // less than one window
    CHECK_RESULT(&ctx, gsf_traj_query_path(&ctx, 6, &desc, &layout), GSF_ERROR_INVALID_ARGUMENT);
}

// ---- paths follow their scene --------------------------------------------------

static void check_following(const curve_scene* s, const gsf_traj_path_desc* base, double scale, const double offset[3],
                            double tolerance) {
    static curve_scene moved;
    move_scene(s, scale, offset, &moved);
    gsf_traj_path_desc desc = *base;
    path a = sample(s->cameras, s->count, &desc);
    if (desc.points) desc.points = moved.points;
    path b = sample(moved.cameras, moved.count, &desc);
    CHECK_OK(&ctx, a.result);
    CHECK_OK(&ctx, b.result);
    double worst = 0.0;
    for (size_t f = 0; f < a.layout.frame_count && a.result == GSF_OK && b.result == GSF_OK; f++) {
        double x[16], y[16];
        gsf_get_camera_c2w(&a.frames[f], x);
        gsf_get_camera_c2w(&b.frames[f], y);
        for (int i = 0; i < 3; i++) y[12 + i] = (y[12 + i] - offset[i]) / scale;
        for (int i = 0; i < 16; i++)
            if (!(fabs(x[i] - y[i]) <= worst)) worst = fabs(x[i] - y[i]);
        CHECK(a.reference[f] == b.reference[f]);
    }
    test_check_near(worst, 0.0, tolerance, "path follows its scene", __FILE__, __LINE__);
    drop(&a);
    drop(&b);
}

static void test_traj_invariance(void) {
    const double none[3] = {0.0, 0.0, 0.0}, far_off[3] = {1e6, -1e6, 1e6}, near_by[3] = {30.0, -7.0, 11.0};
    for (int trial = 0; trial < 60; trial++) {
        curve_scene s;
        make_curve_scene(&s, 2 + (size_t)trial % 9);
        gsf_traj_path_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.kind = (gsf_traj_kind)(trial % 4);
        desc.round = trial % 5;
        if (trial % 2) { desc.points = s.points; desc.point_count = CURVE_POINTS; }
        check_following(&s, &desc, 1e-3, none, 1e-11);
        check_following(&s, &desc, 1e3, none, 1e-11);
        check_following(&s, &desc, 1.0, near_by, 1e-11);
        check_following(&s, &desc, 1.0, far_off, 1e-7); // coordinates are rounded to 1e-10 there
        check_following(&s, &desc, 1e3, far_off, 1e-10);
        desc.official = 1; // the GSFixer release follows scaling about the origin only
        check_following(&s, &desc, 1e-3, none, 1e-11);
        check_following(&s, &desc, 1e3, none, 1e-11);
    }
    for (size_t count = 3; count <= 12; count++) { // an exact ring: all axes and all nearest views are tied
        curve_scene s;
        make_curve_scene(&s, count);
        for (size_t i = 0; i < count; i++) {
            const double angle = 6.283185307179586 * (double)i / (double)count;
            const double eye[3] = {2.0 * cos(angle), 2.0 * sin(angle), 0.5}, target[3] = {0, 0, 0}, up[3] = {0, 0, 1};
            double pose[16];
            CHECK_OK(&ctx, gsf_traj_look_at(&ctx, eye, target, up, pose));
            s.cameras[i] = camera_at(pose);
        }
        gsf_traj_path_desc desc;
        memset(&desc, 0, sizeof desc);
        check_following(&s, &desc, 1e-3, none, 1e-11);
        check_following(&s, &desc, 1e3, near_by, 1e-11);
    }
}

// ---- spread --------------------------------------------------------------------

static double nearest_frame(const path* p, const double at[3]) {
    double nearest = INFINITY;
    for (size_t f = 0; f < p->layout.frame_count; f++) {
        double center[3], square = 0.0;
        gsf_get_camera_center(&p->frames[f], center);
        for (int i = 0; i < 3; i++) square += (center[i] - at[i]) * (center[i] - at[i]);
        nearest = fmin(nearest, sqrt(square));
    }
    return nearest;
}

// Frames come near every position between the cameras, look at the scene, differ from round to round, and stay away from
// an obstacle where there is room.
static void test_spread(void) {
    for (int trial = 0; trial < 20; trial++) {
        curve_scene s;
        make_curve_scene(&s, 2 + (size_t)trial % 9);
        gsf_traj_path_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.kind = GSF_TRAJ_SPREAD;
        desc.window_length = 50;
        desc.window_count = 3;
        desc.seed = (uint64_t)trial;
        path p = sample(s.cameras, s.count, &desc);
        desc.round = 1;
        path next = sample(s.cameras, s.count, &desc);
        if (!CHECK_OK(&ctx, p.result) || !CHECK_OK(&ctx, next.result)) continue;
        double diameter = 0.0, worst = 0.0, same = INFINITY, a[3], b[3];
        for (size_t i = 0; i < s.count; i++)
            for (size_t j = 0; j < i; j++) {
                gsf_get_camera_center(&s.cameras[i], a);
                gsf_get_camera_center(&s.cameras[j], b);
                diameter = fmax(diameter, sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) +
                                               (a[2] - b[2]) * (a[2] - b[2])));
            }
        for (int k = 0; k < 50; k++) { // positions between two cameras
            const double t = uniform(0.0, 1.0);
            gsf_get_camera_center(&s.cameras[test_random_bits(&rng) % s.count], a);
            gsf_get_camera_center(&s.cameras[test_random_bits(&rng) % s.count], b);
            for (int i = 0; i < 3; i++) a[i] += t * (b[i] - a[i]);
            worst = fmax(worst, nearest_frame(&p, a));
        }
        CHECK(worst < 0.3 * diameter);
        for (size_t f = 0; f < p.layout.frame_count; f++) {
            CHECK(p.reference[f] == -1);
            gsf_get_camera_center(&p.frames[f], a);
            same = fmin(same, nearest_frame(&next, a));
        }
        CHECK(same > 0.0);
        drop(&next);
        desc.round = 0;
        double obstacle[3]; // a point where a frame was
        gsf_get_camera_center(&p.frames[70], obstacle);
        desc.points = obstacle;
        desc.point_count = 1;
        path around = sample(s.cameras, s.count, &desc);
        if (CHECK_OK(&ctx, around.result)) CHECK(nearest_frame(&around, obstacle) > 0.0);
        drop(&around);
        drop(&p);
    }
}

// ---- degenerate input ----------------------------------------------------------

static gsf_result result_of(const gsf_camera* cameras, size_t count, gsf_traj_kind kind, int official) {
    gsf_traj_path_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.kind = kind;
    desc.official = official;
    path p = sample(cameras, count, &desc);
    check_frames(&p);
    const gsf_result result = p.result;
    drop(&p);
    return result;
}

static void aim_camera(const double eye[3], const double target[3], const double up[3], gsf_camera* out) {
    double pose[16];
    CHECK_OK(&ctx, gsf_traj_look_at(&ctx, eye, target, up, pose));
    *out = camera_at(pose);
}

static void test_degenerate_cameras(void) {
    const double up[3] = {0.0, 1.0, 0.0}, x_axis[3] = {1.0, 0.0, 0.0}, at_origin[3] = {0.0, 0.0, 0.0};
    gsf_camera c[9];
    for (int official = 0; official < 2; official++) {
        for (int i = 0; i < 9; i++) { // turned about one point
            const double eye[3] = {1.0, 2.0, 3.0}, target[3] = {cos(0.3 * i), 2.0, sin(0.3 * i)};
            aim_camera(eye, target, up, &c[i]);
        }
        const gsf_result turned = result_of(c, 9, GSF_TRAJ_REFERENCE, official);
        CHECK(turned == GSF_ERROR_DEGENERATE);
        CHECK(result_of(c, 9, GSF_TRAJ_ELLIPSE, official) == GSF_ERROR_DEGENERATE);
        CHECK(result_of(c, 9, GSF_TRAJ_INTERPOLATE, official) == GSF_OK);
        for (int i = 1; i < 9; i++) c[i] = c[0]; // one view nine times
        CHECK(result_of(c, 9, GSF_TRAJ_REFERENCE, official) == GSF_ERROR_DEGENERATE);
        CHECK(result_of(c, 9, GSF_TRAJ_INTERPOLATE, official) == GSF_OK);
        for (int i = 0; i < 9; i++) { // a line of cameras with parallel axes
            const double eye[3] = {(double)i, 0.0, 0.0}, target[3] = {(double)i, 0.0, 5.0};
            aim_camera(eye, target, up, &c[i]);
        }
        const gsf_result parallel = official ? GSF_ERROR_DEGENERATE : GSF_OK; // the GSFixer release gives no result
        CHECK(result_of(c, 9, GSF_TRAJ_REFERENCE, official) == parallel);
        CHECK(result_of(c, 2, GSF_TRAJ_ELLIPSE, official) == parallel);
        CHECK(result_of(c, 9, GSF_TRAJ_INTERPOLATE, official) == GSF_OK);
        // a line of cameras with converging axes: the up vector decides on which side the loop runs
        for (int i = 0; i < 9; i++) {
            const double eye[3] = {(double)i - 4.0, 1.0, 0.0}, target[3] = {0.2 * i, 0.5, 5.0};
            aim_camera(eye, target, up, &c[i]);
        }
        CHECK(result_of(c, 9, GSF_TRAJ_REFERENCE, official) == GSF_OK);
        CHECK(result_of(c, 2, GSF_TRAJ_REFERENCE, official) == GSF_OK);
        CHECK(result_of(c, 9, GSF_TRAJ_INTERPOLATE, official) == GSF_OK);
        for (int i = 0; i < 9; i++) { // a vertical line: nothing determines the side
            const double eye[3] = {0.0, (double)i, 0.0}, target[3] = {0.0, 4.0, 5.0};
            aim_camera(eye, target, up, &c[i]);
        }
        const gsf_result vertical = result_of(c, 9, GSF_TRAJ_REFERENCE, official);
        CHECK(vertical == GSF_OK || vertical == GSF_ERROR_DEGENERATE);
        for (int i = 0; i < 9; i++) { // looking straight down, like a drone
            const double eye[3] = {(double)(i % 3), 10.0, (double)(i / 3)}, target[3] = {1.0, 0.0, 1.0};
            aim_camera(eye, target, x_axis, &c[i]);
        }
        const gsf_result drone = result_of(c, 9, GSF_TRAJ_REFERENCE, official);
        CHECK(drone == GSF_OK || drone == GSF_ERROR_DEGENERATE);
        for (int i = 0; i < 2; i++) { // up vectors cancel
            const double eye[3] = {i ? 1.0 : -1.0, 0.0, 0.2}, flipped[3] = {0.0, i ? 1.0 : -1.0, 0.0};
            aim_camera(eye, at_origin, flipped, &c[i]);
        }
        CHECK(result_of(c, 2, GSF_TRAJ_REFERENCE, official) == GSF_ERROR_DEGENERATE);
        curve_scene s; // exactly upside down, where the GSFixer release mirrors the world
        make_curve_scene(&s, 6);
        for (size_t i = 0; i < 6; i++) {
            const double angle = (double)i, eye[3] = {cos(angle), 0.0, sin(angle)}, down[3] = {0.0, -1.0, 0.0};
            const double forward[3] = {-eye[0], 0.0, -eye[2]};
            double pose[16];
            CHECK_OK(&ctx, gsf__traj_view_pose(&ctx, forward, down, eye, pose));
            s.cameras[i] = camera_at(pose);
        }
        CHECK(result_of(s.cameras, 6, GSF_TRAJ_REFERENCE, official) == GSF_OK);
        // sizes at which squares overflow: either a path or an error
        for (int power = -150; power <= 150; power += 10) {
            curve_scene big;
            make_curve_scene(&s, 5);
            move_scene(&s, pow(10.0, power), at_origin, &big);
            (void)result_of(big.cameras, 5, (gsf_traj_kind)((power + 150) / 10 % 3), official);
        }
    }
    CHECK(result_of(c, 0, GSF_TRAJ_REFERENCE, 0) == GSF_ERROR_DEGENERATE);
}

// A row of cameras in front of a wall, their axes rotated by up to `wobble` radians, with a cloud of `count` points on
// that wall: the loop looks at the wall, as the cameras do, at any scale and with an outlier.
static void check_rig(double wobble, double unit, size_t count, int outlier) {
    gsf_camera c[5];
    double points[3 * 50];
    const double up[3] = {0.0, 1.0, 0.0};
    for (int i = 0; i < 5; i++) {
        const double eye[3] = {unit * (i - 2.0), 0.1 * unit * (i % 2), 0.0};
        const double target[3] = {eye[0] + unit * wobble * (i % 2 ? 1.0 : -1.0), eye[1], unit};
        aim_camera(eye, target, up, &c[i]);
    }
    uint64_t state = 5;
    for (int i = 0; i < 3 * 50; i++)
        points[i] = unit * (i % 3 == 2 ? test_random_in(&state, 5.5, 6.5) : test_random_in(&state, -2, 2) * (2 - i % 3));
    if (outlier) points[1] = 1e30;
    for (int round = 0; round < 4; round++) {
        gsf_traj_path_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.round = round;
        desc.points = points;
        desc.point_count = count;
        path p = sample(c, 5, &desc);
        CHECK(p.result == GSF_OK);
        check_frames(&p);
        double least = 1.0, farthest = 0.0;
        for (size_t f = 0; f < p.layout.frame_count && p.result == GSF_OK; f++) {
            double pose[16];
            gsf_get_camera_c2w(&p.frames[f], pose);
            least = fmin(least, pose[10]);
            farthest = fmax(farthest, fmax(fabs(pose[12]), fmax(fabs(pose[13]), fabs(pose[14]))));
        }
        if (!CHECK(least > 0.5 && farthest < 12.0 * unit))
            fprintf(stderr, "wobble %g, unit %g, %zu points, outlier %d: %g, %g\n", wobble, unit, count, outlier, least,
                    farthest / unit);
        drop(&p);
    }
}

static void test_parallel_axes(void) {
    static const double wobbles[] = {0.0, 1e-9, 1e-6, 1e-4, 3e-3}, units[] = {1.0, 0.01, 100.0, 1e-30, 1e20};
    for (size_t w = 0; w < sizeof wobbles / sizeof *wobbles; w++)
        for (size_t u = 0; u < sizeof units / sizeof *units; u++) {
            check_rig(wobbles[w], units[u], 50, 0);
            if (units[u] < 1e19) check_rig(wobbles[w], units[u], 50, 1);
        }
    gsf_camera pair[2]; // facing each other
    const double up[3] = {0.0, 1.0, 0.0}, left[3] = {-1.0, 0.0, 0.0}, right[3] = {1.0, 0.0, 0.0};
    aim_camera(left, right, up, &pair[0]);
    aim_camera(right, left, up, &pair[1]);
    (void)result_of(pair, 2, GSF_TRAJ_REFERENCE, 0);
    CHECK(result_of(pair, 2, GSF_TRAJ_INTERPOLATE, 0) == GSF_OK);
}

// One outlier among sixty points moves no frame by more than a few hundredths of the scene's size, however far away it
// is.
static void test_outliers(void) {
    for (int trial = 0; trial < 40; trial++) {
        curve_scene s;
        make_curve_scene(&s, 3 + (size_t)trial % 7);
        gsf_traj_path_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.kind = trial % 2 ? GSF_TRAJ_ELLIPSE : GSF_TRAJ_REFERENCE;
        desc.points = s.points;
        desc.point_count = CURVE_POINTS - 1;
        path without = sample(s.cameras, s.count, &desc);
        static const double remote[] = {10.0, 40.0, 1e4, 1e30};
        const double direction[3] = {uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-1.0, 1.0)};
        desc.point_count = CURVE_POINTS;
        for (int k = 0; k < 4; k++) {
            for (int i = 0; i < 3; i++)
                s.points[3 * (CURVE_POINTS - 1) + i] = remote[k] * (direction[i] + (direction[i] < 0 ? -1 : 1));
            path with = sample(s.cameras, s.count, &desc);
            CHECK(with.result == without.result);
            double turned = 1.0;
            for (size_t f = 0; f < with.layout.frame_count && with.result == GSF_OK && without.result == GSF_OK; f++) {
                double a[16], b[16];
                gsf_get_camera_c2w(&with.frames[f], a);
                gsf_get_camera_c2w(&without.frames[f], b);
                turned = fmin(turned, a[8] * b[8] + a[9] * b[9] + a[10] * b[10]);
            }
            if (desc.kind == GSF_TRAJ_ELLIPSE && !CHECK(turned > cos(0.2)))
                fprintf(stderr, "trial %d, point at %g: a frame turns by %.3g degrees\n", trial, remote[k],
                        acos(turned) * 57.2957795);
            drop(&with);
        }
        drop(&without);
    }
}

static void test_degenerate_primitives(void) {
    const double o[3] = {0, 0, 0}, x[3] = {1, 0, 0}, y[3] = {0, 1, 0}, nearly[3] = {1e-7, 1, 0};
    double pose[16], a[16], b[16], out[64 * 16], transform[16], scratch[512], focus[3];
    CHECK_RESULT(&ctx, gsf_traj_look_at(&ctx, o, y, y, pose), GSF_ERROR_DEGENERATE); // parallel to up
    CHECK_RESULT(&ctx, gsf_traj_look_at(&ctx, x, x, y, pose), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf_traj_look_at(&ctx, o, x, o, pose), GSF_ERROR_DEGENERATE);
    CHECK_OK(&ctx, gsf_traj_look_at(&ctx, o, nearly, y, pose)); // nearly parallel to up: still a rotation
    CHECK(rigidity(pose) < 1e-14);
    for (int trial = 0; trial < 200; trial++) {
        double forward[3], down[3];
        const double apart = pow(10.0, uniform(-8.0, -1.0));
        for (int i = 0; i < 3; i++) {
            forward[i] = uniform(-1.0, 1.0);
            down[i] = forward[i] * (trial % 2 ? 3.0 : -0.3) + apart * uniform(-1.0, 1.0);
        }
        if (gsf__traj_view_pose(&ctx, forward, down, o, pose) == GSF_OK) CHECK(rigidity(pose) < 1e-14);
        else CHECK(apart < 1e-6);
    }
    CHECK_OK(&ctx, gsf_traj_look_at(&ctx, o, x, y, a));
    for (int i = 0; i < 3; i++) { // distances 0.1 + 0.2, 0.3, 0.3: equal up to rounding, so the first wins
        memcpy(out + 16 * i, a, sizeof a);
        out[16 * i + 12] = i ? 0.3 : 0.1 + 0.2;
    }
    int32_t index;
    CHECK_OK(&ctx, gsf__traj_nearest_view(&ctx, a, out, 3, 0.5, &index, NULL));
    CHECK(index == 0);
    CHECK_RESULT(&ctx, gsf_traj_find_focus(&ctx, a, 1, focus), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf_traj_find_focus(&ctx, a, 0, focus), GSF_ERROR_DEGENERATE);
    memcpy(out, a, sizeof a);
    memcpy(out + 16, a, sizeof a);
    double two[32];
    memcpy(two, out, sizeof two);
    CHECK_RESULT(&ctx, gsf__traj_leg_path(&ctx, two, 2, 8, 1, out), GSF_ERROR_DEGENERATE); // coincide
    CHECK_OK(&ctx, gsf__traj_leg_path(&ctx, two, 2, 8, 0, out));
    for (int i = 0; i < 8; i++) CHECK(rigidity(out + 16 * i) < 1e-14);
    const double back[3] = {-1, 0, 0};
    CHECK_OK(&ctx, gsf_traj_look_at(&ctx, o, back, y, b));
    memcpy(two + 16, b, sizeof b); // opposite directions: the blend of the GSFixer release is zero at u = 1/2
    CHECK_RESULT(&ctx, gsf__traj_leg_path(&ctx, two, 2, 8, 1, out), GSF_ERROR_DEGENERATE);
    for (int i = 0; i < 8 * 16; i++) CHECK(out[i] == 0.0);
    CHECK_OK(&ctx, gsf__traj_leg_path(&ctx, two, 2, 9, 0, out));
    for (int i = 0; i < 9; i++) CHECK(rigidity(out + 16 * i) < 1e-14);
    CHECK_NEAR(fabs(out[4 * 16 + 8]), 0.0, 1e-12); // half way, it looks sideways
    CHECK_RESULT(&ctx, gsf__traj_average_pose(&ctx, two, 2, 0, pose), GSF_ERROR_DEGENERATE);
    memcpy(two + 16, a, sizeof a);
    CHECK_RESULT(&ctx, gsf__traj_spline_path(&ctx, two, 2, NULL, scratch, out), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_spline_path(&ctx, two, 1, NULL, scratch, out), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_slerp_path(&ctx, two, 1, 5, 0.0, scratch, out), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_similarity(&ctx, two, 2, NULL, scratch, transform), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_pca_poses(&ctx, two, 2, out, transform), GSF_ERROR_DEGENERATE);
    const double line[9] = {1, 2, 3, 2, 4, 6, 5, 10, 15}, same[9] = {1, 2, 3, 1, 2, 3, 1, 2, 3};
    CHECK_RESULT(&ctx, gsf__traj_principal_axes(&ctx, line, 3, scratch, transform), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_principal_axes(&ctx, same, 3, scratch, transform), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_principal_axes(&ctx, same, 1, scratch, transform), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&ctx, gsf__traj_principal_axes(&ctx, same, 0, scratch, transform), GSF_ERROR_DEGENERATE);
    const double sites[3] = {0, 1, 1}, values[3] = {0, 1, 2};
    gsf__traj_curve curve;
    CHECK(!gsf__traj_make_curve(&curve, sites, values, 1, 3, 1, 2, scratch)); // sites that do not ascend
    a[0] = -a[0]; a[1] = -a[1]; a[2] = -a[2]; // a reflection
    CHECK_RESULT(&ctx, gsf__traj_check_poses(&ctx, a, 1), GSF_ERROR_INVALID_ARGUMENT);
}

// ---- NaN anywhere --------------------------------------------------------------

static void test_traj_not_finite(void) {
    const double bad_values[3] = {NAN, INFINITY, -INFINITY};
    curve_scene s;
    make_curve_scene(&s, 4);
    double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    for (int kind = 0; kind < 3; kind++)
        for (int v = 0; v < 3; v++) {
            gsf_traj_path_desc desc;
            memset(&desc, 0, sizeof desc);
            desc.kind = (gsf_traj_kind)kind;
            desc.window_length = 10;
            desc.points = s.points;
            desc.point_count = CURVE_POINTS;
            gsf_camera intrinsics = s.cameras[0];
            desc.intrinsics = &intrinsics;
            double* fields[4 * 20 + 3 * CURVE_POINTS + 4]; // every input number
            size_t n = 0;
            for (size_t i = 0; i < 4; i++) {
                for (int k = 0; k < 16; k++) fields[n++] = &s.cameras[i].w2c[k];
                fields[n++] = &s.cameras[i].fx;
                fields[n++] = &s.cameras[i].fy;
                fields[n++] = &s.cameras[i].cx;
                fields[n++] = &s.cameras[i].cy;
            }
            for (int i = 0; i < 3 * CURVE_POINTS; i++) fields[n++] = &s.points[i];
            fields[n++] = &intrinsics.fx;
            fields[n++] = &intrinsics.cy;
            for (size_t i = 0; i < n; i++) {
                const double keep = *fields[i];
                *fields[i] = bad_values[v];
                path p = sample(s.cameras, 4, &desc);
                CHECK(p.result == GSF_ERROR_NUMERIC || p.result == GSF_ERROR_INVALID_ARGUMENT);
                CHECK(ctx.error[0] != 0);
                check_frames(&p);
                drop(&p);
                *fields[i] = keep;
            }
            for (int i = 0; i < 16; i++) {
                const double keep = identity[i];
                identity[i] = bad_values[v];
                desc.transform = identity;
                path p = sample(s.cameras, 4, &desc);
                CHECK(p.result == GSF_ERROR_NUMERIC);
                drop(&p);
                identity[i] = keep;
            }
            desc.transform = NULL;
            gsf_traj_ellipse_desc ellipse = gsf__traj_round_ellipse(0, 0, 0);
            double* shape[3] = {&ellipse.z_variation, &ellipse.z_phase, &ellipse.pitch_degrees};
            desc.ellipse = &ellipse;
            for (int i = 0; i < 3 && kind != GSF_TRAJ_INTERPOLATE; i++) {
                const double keep = *shape[i];
                *shape[i] = bad_values[v];
                path p = sample(s.cameras, 4, &desc);
                CHECK(p.result == GSF_ERROR_NUMERIC);
                drop(&p);
                *shape[i] = keep;
            }
        }
}

static void test_not_finite_primitives(void) {
    curve_scene s;
    make_curve_scene(&s, 4);
    double poses[64], out[64 * 16], scratch[2048], transform[16], three[3], radius;
    int32_t index;
    for (size_t i = 0; i < 4; i++) gsf_get_camera_c2w(&s.cameras[i], poses + 16 * i);
    for (int i = 0; i < 64; i++) {
        const double keep = poses[i];
        poses[i] = i % 2 ? NAN : INFINITY;
        CHECK_RESULT(&ctx, gsf__traj_check_poses(&ctx, poses, 4), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf_traj_find_focus(&ctx, poses, 4, three), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_average_pose(&ctx, poses, 4, 0, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_recenter_poses(&ctx, poses, 4, 0, out, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_camera_radius(&ctx, poses, 4, three, &radius), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_nearest_view(&ctx, poses, poses, 4, 0.5, &index, NULL), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_similarity(&ctx, poses, 4, NULL, scratch, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_normalize(&ctx, poses, 4, NULL, 0, NULL, scratch, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_pca_poses(&ctx, poses, 4, out, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_spline_path(&ctx, poses, 4, NULL, scratch, out), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_slerp_path(&ctx, poses, 4, 8, 0.0, scratch, out), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_leg_path(&ctx, poses, 4, 4, 0, out), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_ellipse_path(&ctx, poses, 4, NULL, scratch, out), GSF_ERROR_NUMERIC);
        if (i < 16) CHECK_RESULT(&ctx, gsf__traj_invert_similarity(&ctx, poses, out), GSF_ERROR_NUMERIC);
        poses[i] = keep;
    }
    for (int i = 0; i < 9; i++) {
        double v[9] = {0.1, 0.2, 0.3, 1.0, 0.5, 0.2, 0.0, 1.0, 0.0};
        v[i] = NAN;
        CHECK_RESULT(&ctx, gsf_traj_look_at(&ctx, v, v + 3, v + 6, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_view_pose(&ctx, v, v + 3, v + 6, transform), GSF_ERROR_NUMERIC);
        CHECK_RESULT(&ctx, gsf__traj_principal_axes(&ctx, v, 3, scratch, transform), GSF_ERROR_NUMERIC);
    }
    CHECK_RESULT(&ctx, gsf__traj_slerp_path(&ctx, poses, 4, 8, NAN, scratch, out), GSF_ERROR_NUMERIC);
    CHECK_RESULT(&ctx, gsf__traj_nearest_view(&ctx, poses, poses, 4, NAN, &index, NULL), GSF_ERROR_NUMERIC);
}

// ---- building blocks against plain formulas ------------------------------------

static void test_order_and_eigen(void) {
    for (int trial = 0; trial < 300; trial++) {
        double v[40], sum = 0.0, after = 0.0;
        const size_t n = 1 + test_random_bits(&rng) % 40;
        for (size_t i = 0; i < n; i++) {
            v[i] = trial % 3 ? uniform(-1.0, 1.0) : (double)(test_random_bits(&rng) % 4);
            sum += v[i] * v[i];
        }
        gsf__traj_sort(v, n);
        for (size_t i = 0; i < n; i++) after += v[i] * v[i];
        for (size_t i = 1; i < n; i++) CHECK(v[i - 1] <= v[i]);
        CHECK_NEAR(after, sum, 1e-12 * (1.0 + sum));
        CHECK_NEAR(gsf__traj_percentile(v, n, 0.5), gsf__traj_median(v, n), 1e-15);
        CHECK(gsf__traj_percentile(v, n, 0.0) == v[0]);
        CHECK(gsf__traj_percentile(v, n, 1.0) == v[n - 1]);

        double a[9], values[3], rows[9];
        const double scale = pow(10.0, uniform(-100.0, 100.0));
        for (int i = 0; i < 3; i++)
            for (int j = 0; j <= i; j++) a[3 * i + j] = a[3 * j + i] = scale * uniform(-1.0, 1.0);
        if (trial % 5 == 0) a[0] = a[4] = a[8] = scale;
        if (trial % 7 == 0) a[1] = a[3] = a[2] = a[6] = 0.0;
        gsf__mat3_eigen(a, values, rows);
        CHECK(values[0] >= values[1] && values[1] >= values[2]);
        for (int k = 0; k < 3; k++)
            for (int i = 0; i < 3; i++) {
                const double* r = rows + 3 * k;
                const double row = a[3 * i] * r[0] + a[3 * i + 1] * r[1] + a[3 * i + 2] * r[2];
                CHECK_NEAR(row, values[k] * r[i], 4e-14 * scale);
                const double* q = rows + 3 * i;
                CHECK_NEAR(q[0] * r[0] + q[1] * r[1] + q[2] * r[2], i == k, 1e-14);
            }
    }
}

static void test_rotations(void) {
    for (int trial = 0; trial < 300; trial++) {
        double q[4], p[4], pose[16], back[4], other[16], half[16], out[4];
        for (int i = 0; i < 4; i++) q[i] = trial < 8 ? (double)(i == trial % 4) : uniform(-1.0, 1.0);
        for (int i = 0; i < 4; i++) p[i] = uniform(-1.0, 1.0);
        memset(pose, 0, sizeof pose);
        memset(other, 0, sizeof other);
        gsf__traj_quat_axes(q, pose);
        gsf__traj_quat_axes(p, other);
        CHECK(rigidity(pose) < 1e-14);
        gsf__quat_of(pose, back);
        gsf__quat_of(other, p);
        const double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        double dot = 0.0;
        for (int i = 0; i < 4; i++) dot += back[i] * q[i] / length;
        CHECK_NEAR(fabs(dot), 1.0, 1e-14);
        // slerp: reaches both ends, and the angle grows at a constant rate
        double angle[5];
        for (int k = 0; k < 5; k++) {
            gsf__traj_slerp(back, p, 0.25 * k, out);
            double c = 0.0;
            for (int i = 0; i < 4; i++) c += out[i] * back[i];
            angle[k] = 2.0 * acos(fabs(c) > 1.0 ? 1.0 : fabs(c));
        }
        for (int k = 1; k < 4; k++) CHECK_NEAR(angle[k], 0.25 * k * angle[4], 1e-6);
        pose[12] = 1.0;
        other[13] = 4.0;
        gsf__traj_blend_poses(pose, other, 0.5, half);
        CHECK(rigidity(half) < 1e-14);
        CHECK_NEAR(half[12], 0.5, 1e-15);
        CHECK_NEAR(half[13], 2.0, 1e-15);
        gsf__traj_blend_poses(pose, other, 1.0, half);
        test_compare("slerp at 1", half, other, 16, 1e-14);
        gsf__traj_blend_poses(pose, pose, 0.3, pose); // coincident, in place
        CHECK(rigidity(pose) < 1e-14);
    }
}

// A spline of degree k reproduces polynomials up to degree k, passes through its values, and is C(k-1) continuous.
static void test_splines(void) {
    for (int trial = 0; trial < 200; trial++) {
        const int32_t degree = 1 + trial % 5;
        const size_t n = (size_t)degree + 1 + test_random_bits(&rng) % 12, dims = 1 + (size_t)trial % 4;
        double sites[32], values[32 * 4], at[40], expected[40 * 4], coefficients[6 * 4];
        sites[0] = uniform(-1.0, 1.0);
        for (size_t i = 1; i < n; i++) sites[i] = sites[i - 1] + uniform(0.3, 1.0);
        for (size_t i = 0; i < 24; i++) coefficients[i] = uniform(-1.0, 1.0);
        for (int i = 0; i < 40; i++) at[i] = sites[0] + (sites[n - 1] - sites[0]) * i / 39.0;
        for (size_t d = 0; d < dims; d++)
            for (int i = 0; i < 40 + (int)n; i++) {
                const double x = (i < 40 ? at[i] : sites[i - 40]) / sites[n - 1];
                double sum = 0.0;
                for (int k = degree; k >= 0; k--) sum = sum * x + coefficients[4 * k + (int)d];
                if (i < 40) expected[(size_t)i * dims + d] = sum;
                else values[(size_t)(i - 40) * dims + d] = sum;
            }
        double* scratch = (double*)allocate(gsf__traj_curve_doubles(n, degree, dims) * sizeof(double));
        double* out = (double*)allocate(40 * dims * sizeof(double));
        gsf__traj_curve curve;
        CHECK(gsf__traj_make_curve(&curve, sites, values, dims, n, dims, degree, scratch));
        for (size_t i = 0; i < 40; i++) gsf__traj_eval_curve(&curve, at[i], out + i * dims);
        test_compare("polynomial", out, expected, 40 * dims, 1e-9 * (1.0 + test_max_abs(expected, 40 * dims)));
        for (size_t i = 0; i < n * dims; i++) values[i] = uniform(-1.0, 1.0);
        CHECK(gsf__traj_make_curve(&curve, sites, values, dims, n, dims, degree, scratch));
        for (size_t i = 0; i < n; i++) gsf__traj_eval_curve(&curve, sites[i], out + i * dims);
        test_compare("interpolation", out, values, n * dims, 1e-10);
        free(out);
        free(scratch);
    }
    CHECK(gsf__traj_slerp_path_scratch(SIZE_MAX / 8) == SIZE_MAX);
    CHECK(gsf__traj_normalize_scratch(4, SIZE_MAX / 4) == SIZE_MAX);
    // spline paths pass through their poses, with scratch memory of exactly the size queried
    for (size_t count = 2; count <= 20; count++) {
        curve_scene s;
        make_curve_scene(&s, count);
        double poses[32 * 16];
        for (size_t i = 0; i < count; i++) gsf_get_camera_c2w(&s.cameras[i], poses + 16 * i);
        gsf__traj_spline_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.degree = 1 + (int32_t)count % 5;
        desc.frames_per_leg = 7;
        double* out = (double*)allocate((count - 1) * 7 * 16 * sizeof(double));
        void* scratch = allocate(gsf__traj_spline_path_scratch(count, &desc));
        CHECK_OK(&ctx, gsf__traj_spline_path(&ctx, poses, count, &desc, scratch, out));
        test_compare("first pose", out, poses, 16, 1e-12);
        for (size_t i = 0; i < (count - 1) * 7; i++) CHECK(rigidity(out + 16 * i) < 1e-12);
        free(scratch);
        free(out);
        out = (double*)allocate(((count - 1) * 5 + 1) * 16 * sizeof(double));
        scratch = allocate(gsf__traj_slerp_path_scratch(count));
        CHECK_OK(&ctx, gsf__traj_slerp_path(&ctx, poses, count, (int32_t)(count - 1) * 5 + 1, 0.0, scratch, out));
        for (size_t i = 0; i < count; i++) test_compare("slerp path", out + 80 * i, poses + 16 * i, 16, 1e-10);
        free(scratch);
        free(out);
    }
}

static void test_sets_of_views(void) {
    for (int trial = 0; trial < 100; trial++) {
        const size_t n = 3 + (size_t)trial % 8;
        double poses[16 * 16], out[16 * 16], transform[16], focus[3], center[3], radius;
        const double target[3] = {uniform(-5.0, 5.0), uniform(-5.0, 5.0), uniform(-5.0, 5.0)}, up[3] = {0.1, 1.0, 0.2};
        for (size_t i = 0; i < n; i++) {
            double eye[3];
            for (int k = 0; k < 3; k++)
                eye[k] = target[k] + uniform(0.5, 2.0) * (test_random_bits(&rng) % 2 ? 1.0 : -1.0);
            CHECK_OK(&ctx, gsf_traj_look_at(&ctx, eye, target, up, poses + 16 * i));
        }
        CHECK_OK(&ctx, gsf_traj_find_focus(&ctx, poses, n, focus)); // intersecting axes
        test_compare("focus", focus, target, 3, 1e-10);
        int32_t index;
        for (size_t i = 0; i < n; i++) {
            CHECK_OK(&ctx, gsf__traj_nearest_view(&ctx, poses + 16 * i, poses, n, 0.5, &index, NULL));
            CHECK((size_t)index == i);
        }
        void* scratch = allocate(gsf__traj_normalize_scratch(n, 0));
        CHECK_OK(&ctx, gsf__traj_normalize(&ctx, poses, n, NULL, 0, NULL, scratch, transform));
        free(scratch);
        gsf__traj_transform_poses(transform, poses, n, out);
        for (size_t i = 0; i < n; i++) CHECK(rigidity(out + 16 * i) < 1e-13);
        double back[16];
        CHECK_OK(&ctx, gsf__traj_invert_similarity(&ctx, transform, back));
        gsf__traj_transform_poses(back, out, n, out); // in place
        test_compare("there and back", out, poses, 16 * n, 1e-12 * (1.0 + test_max_abs(poses, 16 * n)));
        if (gsf__traj_recenter_poses(&ctx, poses, n, 0, out, transform) == GSF_OK) {
            double mean[16];
            CHECK_OK(&ctx, gsf__traj_average_pose(&ctx, out, n, 0, mean));
            const double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
            test_compare("average of recentred poses", mean, identity, 16, 1e-9);
        }
        CHECK_OK(&ctx, gsf__traj_pca_poses(&ctx, poses, n, out, transform));
        CHECK_OK(&ctx, gsf__traj_camera_radius(&ctx, out, n, center, &radius));
        for (int k = 0; k < 3; k++) CHECK_NEAR(center[k], 0.0, 1e-12);
        double most = 0.0;
        for (size_t i = 0; i < n; i++) most = fmax(most, test_max_abs(out + 16 * i + 12, 3));
        CHECK_NEAR(most, 1.0, 1e-12);
    }
}

static void test_schedule(void) {
    static const int32_t even[4] = {100, 150, 200, 250}, uneven[4] = {10, 13, 16, 20}; // 3 1/3 apart
    for (int32_t k = 0; k < 4; k++) {
        CHECK(gsf_traj_query_repair_round(100, 250, 4, k) == even[k]);
        CHECK(gsf_traj_query_repair_round(10, 20, 4, k) == uneven[k]);
    }
    CHECK(gsf_traj_query_repair_round(100, 210, 1, 0) == 100);
    CHECK(gsf_traj_query_repair_round(7, INT32_MAX, 1001, 1000) == INT32_MAX);
    CHECK(gsf_traj_query_generative_weight(10, 10, 20, 1.0, 0) == 0.0);
    CHECK(gsf_traj_query_generative_weight(20, 10, 20, 0.75, 0) == 0.75 && gsf_traj_query_generative_weight(20, 10, 20,
                                                                                                            0.75, 1) == 0.0);
    for (int i = 12; i < 20; i++) // keeps rising; that of the GSFixer release falls again
        CHECK(gsf_traj_query_generative_weight(i, 10, 20, 2.0, 0) > gsf_traj_query_generative_weight(i - 1, 10, 20, 2.0,
                                                                                                     0));
    for (int i = 11; i < 20; i++) {
        const double t = 0.1 * i - 1.0;
        CHECK_NEAR(gsf_traj_query_generative_weight(i, 10, 20, 2.0, 0), 2.0 * t * (2.0 - t), 1e-6);
    }
    CHECK(gsf_traj_query_generative_weight(19, 10, 20, 2.0, 1) < gsf_traj_query_generative_weight(15, 10, 20, 2.0, 1));
    // the tables of the GSFixer release: indices inside the sequence, or an error
    for (int32_t total = 1; total < 300; total++)
        for (int32_t middle = 1; middle < 40; middle++) {
            int32_t windows, starts[310], overlaps[310];
            if (gsf__traj_official_windows(&ctx, total, middle, NULL, NULL, &windows) != GSF_OK) {
                CHECK(windows == 0);
                continue;
            }
            if (!CHECK(windows <= 310)) continue;
            CHECK_OK(&ctx, gsf__traj_official_windows(&ctx, total, middle, starts, overlaps, &windows));
            int wrong = starts[0] != 0;
            for (int32_t w = 1; w < windows; w++) {
                wrong += starts[w] < 0 || starts[w] + middle > total;
                wrong += starts[w] != starts[w - 1] + middle - overlaps[w];
            }
            CHECK(wrong == 0);
        }
}

int main(void) {
    test_context_init(&ctx);
    test_order_and_eigen();
    test_rotations();
    test_splines();
    test_sets_of_views();
    test_schedule();
    test_defaults();
    test_all_sizes();
    test_traj_invariance();
    test_spread();
    test_degenerate_cameras();
    test_parallel_axes();
    test_outliers();
    test_degenerate_primitives();
    test_traj_not_finite();
    test_not_finite_primitives();
    return test_report();
}
