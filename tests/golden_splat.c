// golden_splat.c - the rasterizer (forward, backward, radii) against the golden scenes with the float32 tolerances of
// golden/splat/README.md, and against the double-precision reference (reference_splat.h) on the golden and on random
// scenes, at every CPU level of the machine; the same bits for any number and order of workers.
//
// Only pixels in which the reference's binary decisions (1/255, 0.99, 1e-4, depth order) are clear of their thresholds
// are compared; the others get no incoming gradient and are counted.
// Loss, Adam, learning rates and densification are compared with their golden data, too (train_golden.h, which needs the
// implementation in this file).
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"
#include "reference_splat.h"
#include "splat_golden.h"
#include "train_golden.h"
#include "splat_run.h"

// ---- comparison ----------------------------------------------------------------

typedef struct worst { double image, alpha, depth, gradient; } worst; // errors divided by their tolerances

// max |actual - expected| over rows (of `width` values) with skip[row] == 0; rows scaled by row_scale where given.
static double max_error(const float* actual, const double* expected, size_t rows, size_t width, const uint8_t* skip,
                        const double* row_scale) {
    double error = 0;
    for (size_t i = 0; i < rows * width; i++) {
        if (skip && skip[i / width]) continue;
        const double e = fabs((double)actual[i] - expected[i]);
        error = nan_max(error, row_scale ? e * row_scale[i / width] : e);
        if (error != error) return error;
    }
    return error;
}

static double max_scaled(const double* v, size_t rows, size_t width, const double* row_scale) {
    double m = 0;
    for (size_t i = 0; i < rows * width; i++) m = fmax(m, fabs(v[i]) * (row_scale ? row_scale[i / width] : 1));
    return m;
}

// Checks error <= tolerance; returns error / tolerance.
static double check_error(const char* label, const char* what, double error, double tolerance) {
    if (!CHECK(error <= tolerance))
        fprintf(stderr, "%s: %s is off by %.3g, allowed %.3g\n", label, what, error, tolerance);
    return error > 0 ? error / tolerance : error;
}

static void note_worst(double* field, double share) { *field = nan_max(*field, share); }

// ---- golden scenes -------------------------------------------------------------

static void golden_gradients(const char* label, const splat_golden* g, const result* r, int official, double tolerance,
                             worst* w) {
    const struct { const char* name; const float* actual; } list[] = {
        {"means", r->grads.means}, {"scales_log", r->grads.log_scales}, {"quats_raw", r->grads.quats},
        {"opacity_logit", r->grads.opacity_logits}, {"sh", r->grads.sh}, {"means2d_pix", r->grads.means2d},
    };
    for (size_t k = 0; k < sizeof list / sizeof list[0]; k++) {
        test_tensor expected = splat_golden_gradient(g, official, list[k].name);
        const double size = test_max_abs(expected.v, expected.count);
        const double error = max_error(list[k].actual, expected.v, expected.count, 1, NULL, NULL);
        note_worst(&w->gradient, check_error(label, list[k].name, error, tolerance * size));
        test_free_tensor(&expected);
    }
}

static void golden_scene(machine* m, const splat_golden* g, int official, worst* w) {
    const double image_tolerance = g->fragile ? 2e-3 : 5e-5, gradient_tolerance = g->fragile ? 3e-3 : 1e-4;
    char label[128];
    snprintf(label, sizeof label, "golden %s, %s, %s gradient", g->name, m->name, official ? "official" : "true");
    gsf_render_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.sh_bands = g->sh_bands;
    for (int c = 0; c < 3; c++) desc.background[c] = (float)g->background[c];
    desc.footprint = GSF_FOOTPRINT_OFFICIAL;
    desc.gradient = official ? GSF_GRADIENT_OFFICIAL : GSF_GRADIENT_TRUE;
    const loss l = {g->d_color, NULL, NULL};
    result r = render(m, &g->splats, &g->camera, &desc, &l);

    test_tensor T = test_get_tensor(&g->file, "out.T");
    test_tensor depth = test_get_tensor(&g->file, "out.depth_expected"), radii = test_get_tensor(&g->file, "out.radii");
    double* image = splat_golden_image(g, "out.image");
    for (size_t i = 0; i < g->pixels; i++) T.v[i] = 1 - T.v[i];
    note_worst(&w->image,
               check_error(label, "image", max_error(r.color, image, g->pixels, 3, NULL, NULL), image_tolerance));
    note_worst(&w->alpha,
               check_error(label, "alpha", max_error(r.alpha, T.v, g->pixels, 1, NULL, NULL), image_tolerance));
    note_worst(&w->depth, check_error(label, "depth", max_error(r.depth, depth.v, g->pixels, 1, NULL, NULL),
                                          image_tolerance * test_max_abs(depth.v, depth.count)));
    size_t wrong = 0;
    for (size_t i = 0; i < g->splats.count; i++) wrong += r.radii[i] != (int32_t)radii.v[i];
    if (!CHECK(wrong == 0)) fprintf(stderr, "%s: %zu radii differ\n", label, wrong);
    golden_gradients(label, g, &r, official, gradient_tolerance, w);
    free(image);
    test_free_tensor(&T); test_free_tensor(&depth); test_free_tensor(&radii);
    result_free(&r);
}

// ---- against the reference -----------------------------------------------------

typedef struct oracle { // a scene with the reference's image and gradients
    gsf_splats* splats;
    gsf_camera* camera;
    gsf_render_desc* desc;
    char label[128];
    ref_image image;
    ref_grads grads;
    loss l;
    double* alpha;
    double* quat_norm; // quaternion gradients are scaled by |q|, or those of small quaternions would dominate
    uint8_t* skip;     // pixels with an unclear decision
    size_t skipped, pixels;
} oracle;

// Tolerances against the reference for every scene, needles included; pixels within MARGIN of a decision are skipped.
#define IMAGE_TOLERANCE 5e-5
#define GRADIENT_TOLERANCE 1e-4
#define MARGIN 1e-4
#define DEPTH_GAP 1e-6

// d_color: the incoming gradient of the golden scene; NULL: random.
static oracle oracle_make(const char* label, gsf_splats* splats, gsf_camera* camera, gsf_render_desc* desc,
                          const double* d_color, uint64_t seed) {
    oracle o;
    memset(&o, 0, sizeof o);
    snprintf(o.label, sizeof o.label, "%s", label);
    o.splats = splats;
    o.camera = camera;
    o.desc = desc;
    const ref_splats s = ref_splats_from(splats);
    const ref_options options = ref_options_from(desc);
    o.image = ref_render(&s, camera, &options);
    o.pixels = (size_t)camera->width * (size_t)camera->height;
    uint64_t state = seed;
    const double size = d_color ? test_max_abs(d_color, 3 * o.pixels) : 1;
    o.l.d_color = random_values(&state, 3 * o.pixels, size);
    if (d_color) memcpy(o.l.d_color, d_color, 3 * o.pixels * sizeof(double));
    o.l.d_depth = random_values(&state, o.pixels, 0.2 * size);
    o.l.d_alpha = random_values(&state, o.pixels, size);
    o.alpha = (double*)malloc((o.pixels + 1) * sizeof(double));
    o.skip = (uint8_t*)calloc(o.pixels + 1, 1);
    for (size_t i = 0; i < o.pixels; i++) {
        o.alpha[i] = 1 - o.image.T[i];
        // Expected depth is divided by alpha, so in float32 its error is 6e-8 / alpha. Scale its gradient by alpha, as a
        // loss would that ignores the depth of empty pixels.
        o.l.d_depth[i] = (double)(float)(o.l.d_depth[i] * o.alpha[i]);
        o.skip[i] = o.image.margin[i] < MARGIN || o.image.depth_gap[i] < DEPTH_GAP;
        if (!o.skip[i]) continue;
        o.skipped++;
        for (size_t c = 0; c < 3; c++) o.l.d_color[3 * i + c] = 0;
        o.l.d_depth[i] = o.l.d_alpha[i] = 0;
    }
    o.quat_norm = (double*)malloc((splats->count + 1) * sizeof(double));
    for (size_t i = 0; i < splats->count; i++) {
        const double* q = s.quats + 4 * i;
        o.quat_norm[i] = fmax(sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), 1e-12);
    }
    o.grads = ref_make_grads(s.count, s.sh_count);
    ref_render_backward(&s, camera, &options, &o.image, o.l.d_color, o.l.d_depth, o.l.d_alpha, &o.grads);
    ref_splats gone = s;
    ref_destroy_splats(&gone);
    return o;
}

static void oracle_free(oracle* o) {
    ref_destroy_image(&o->image);
    ref_destroy_grads(&o->grads);
    free(o->l.d_color); free(o->l.d_depth); free(o->l.d_alpha);
    free(o->alpha); free(o->skip); free(o->quat_norm);
}

static void oracle_compare(const oracle* o, const char* level, const result* r, worst* w) {
    char label[160];
    snprintf(label, sizeof label, "%s, %s", o->label, level);
    double color_max = 1, z_max = 0;
    for (size_t i = 0; i < o->pixels; i++) {
        for (size_t c = 0; c < 3; c++) color_max = fmax(color_max, fabs(o->image.color[3 * i + c]));
        z_max = fmax(z_max, o->image.depth[i]);
    }
    note_worst(&w->image, check_error(label, "image", max_error(r->color, o->image.color, o->pixels, 3, o->skip, NULL),
                                          IMAGE_TOLERANCE * color_max));
    note_worst(&w->alpha, check_error(label, "alpha", max_error(r->alpha, o->alpha, o->pixels, 1, o->skip, NULL),
                                          IMAGE_TOLERANCE));
    note_worst(&w->depth, check_error(label, "depth", max_error(r->depth, o->image.depth, o->pixels, 1, o->skip, NULL),
                                          IMAGE_TOLERANCE * z_max));
    const size_t n = o->splats->count;
    const struct { const char* name; const float* actual; const double* expected; size_t rows, width; } list[] = {
        {"means", r->grads.means, o->grads.means, n, 3},
        {"log_scales", r->grads.log_scales, o->grads.log_scales, n, 3},
        {"quats", r->grads.quats, o->grads.quats, n, 4},
        {"opacity_logits", r->grads.opacity_logits, o->grads.logits, n, 1},
        {"sh", r->grads.sh, o->grads.sh, n, r->sh_floats},
        {"means2d", r->grads.means2d, o->grads.means2d, n, 2},
        {"means2d_abs", r->grads.means2d_abs, o->grads.means2d_abs, n, 2},
        {"background", r->grads.background, o->grads.background, 1, 3},
    };
    for (size_t k = 0; k < sizeof list / sizeof list[0]; k++) {
        const double* scale = list[k].width == 4 ? o->quat_norm : NULL;
        const double size = max_scaled(list[k].expected, list[k].rows, list[k].width, scale);
        const double error = max_error(list[k].actual, list[k].expected, list[k].rows, list[k].width, NULL, scale);
        note_worst(&w->gradient, check_error(label, list[k].name, error, GRADIENT_TOLERANCE * size));
    }
    if (o->desc->footprint == GSF_FOOTPRINT_OFFICIAL) {
        size_t wrong = 0;
        for (size_t i = 0; i < n; i++) wrong += (int64_t)r->radii[i] != o->image.splats[i].radius;
        if (!CHECK(wrong == 0)) fprintf(stderr, "%s: %zu radii differ\n", label, wrong);
    }
}

// ---- random scenes -------------------------------------------------------------

typedef enum kind {
    ORDINARY,   // aspect up to 20, in front of the camera
    CROSSERS,   // depths from behind the camera through the near plane
    AROUND,     // the camera is inside the cloud
    OPACITIES,  // logits of +-20
    QUATERNIONS,// lengths 1e-8 .. 1e8, and zero
    SIZES,      // far below a pixel and far above the image
    TIES,       // many splats share a mean
    REMOTE,        // origin and camera thousands of kilometres from zero
    NEEDLES,    // aspect 1e3 .. 1e4
    KINDS
} kind;
static const char* const kind_names[KINDS] = {"ordinary",    "crossers", "around", "opacities", "quaternions",
                                              "sizes",       "ties",     "far",    "needles"};

// Draws splat i. The cloud has radius 1 around the origin; pixel: size of a pixel at its centre.
static void random_splat(gsf_splats* s, size_t i, kind what, double pixel, uint64_t* state) {
    const double reach = what == CROSSERS ? 2.5 : 1.2;
    for (int k = 0; k < 3; k++) s->means[3 * i + k] = (float)test_random_in(state, -reach, reach);
    if (what == TIES && i > 0 && test_random(state) < 0.7)
        memcpy(s->means + 3 * i, s->means + 3 * (size_t)(test_random(state) * (double)i), 3 * sizeof(float));
    double size = random_log(state, 0.7 * pixel, 12 * pixel), aspect = random_log(state, 1, 20);
    if (what == SIZES)
        size = test_random(state) < 0.7 ? random_log(state, 1e-4 * pixel, pixel) : random_log(state, 1, 50);
    if (what == NEEDLES) { size = random_log(state, 10 * pixel, 300 * pixel); aspect = random_log(state, 1e3, 1e4); }
    for (int k = 0; k < 3; k++)
        s->log_scales[3 * i + k] =
            (float)(log(size) - (k == (int)(i % 3) ? 0 : test_random_in(state, 0.7, 1) * log(aspect)));
    const double length = what == QUATERNIONS ? random_log(state, 1e-8, 1e8) : random_log(state, 0.5, 2);
    double q[4], norm = 0;
    do {
        for (int k = 0; k < 4; k++) q[k] = test_random_in(state, -1, 1);
        norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    } while (norm < 0.2);
    for (int k = 0; k < 4; k++) s->quats[4 * i + k] = (float)(q[k] / norm * length);
    if (what == QUATERNIONS && i % 9 == 4) memset(s->quats + 4 * i, 0, 4 * sizeof(float));
    s->opacity_logits[i] = (float)test_random_in(state, -3, 4);
    if (what == OPACITIES && i % 3) s->opacity_logits[i] = i % 3 == 1 ? 20.0f : -20.0f;
    const size_t K = (size_t)gsf_splat_count_sh(s->sh_degree);
    for (size_t k = 0; k < 3 * K; k++)
        s->sh[3 * K * i + k] = (float)test_random_in(state, k < 3 ? -1.5 : -0.3, k < 3 ? 1.5 : 0.3);
}

typedef struct random_scene {
    kind what;
    gsf_splats splats;
    gsf_camera camera;
    gsf_render_desc desc;
    uint8_t* hidden;
    char label[128];
} random_scene;

static random_scene random_scene_make(gsf_context* ctx, uint64_t seed) {
    static const int32_t sizes[][2] = {{65, 33}, {17, 3}, {1, 1}, {200, 130}, {48, 64}, {33, 1}, {5, 90}};
    static const size_t counts[] = {60, 300, 7, 2000, 1, 120, 0, 600};
    random_scene r;
    memset(&r, 0, sizeof r);
    uint64_t state = seed * 7919 + 1;
    r.what = (kind)(seed % KINDS); // successive seeds combine every kind with every size and option
    const int32_t* size = sizes[(seed + seed / KINDS) % 7];
    const size_t count = counts[(seed + seed / 7) % 8];
    const int32_t degree = (int32_t)(test_random(&state) * 4);
    CHECK_OK(ctx, gsf_splat_make(ctx, count, degree, &r.splats));
    const double far_away[3] = {4.1e6, -2.7e6, 5.3e5}, zero[3] = {0, 0, 0};
    if (r.what == REMOTE) memcpy(r.splats.origin, far_away, sizeof far_away);
    r.camera = random_camera(&state, size[0], size[1], r.what == REMOTE ? far_away : zero, r.what == AROUND ? 0.2 : 3);
    r.desc.sh_bands = (int32_t)(test_random(&state) * 5);
    for (int c = 0; c < 3; c++) r.desc.background[c] = (float)test_random_in(&state, 0.1, 1);
    r.desc.antialiased = test_random(&state) < 0.4;
    r.desc.footprint = test_random(&state) < 0.25 ? GSF_FOOTPRINT_OFFICIAL : GSF_FOOTPRINT_FULL;
    r.desc.gradient = test_random(&state) < 0.2 ? GSF_GRADIENT_OFFICIAL : GSF_GRADIENT_TRUE;
    r.desc.near_plane = test_random(&state) < 0.3 ? 0.01f : 0;
    const double opacity_scale = test_random(&state);
    r.desc.opacity_scale = opacity_scale < 0.2 ? 1.1f : opacity_scale < 0.5 ? 0.7f : 0;
    r.hidden = (uint8_t*)calloc(count + 1, 1);
    if (test_random(&state) < 0.4) {
        for (size_t i = 0; i < count; i++) r.hidden[i] = test_random(&state) < 0.2;
        r.desc.hidden = r.hidden;
    }
    const double pixel = 3 / r.camera.fx;
    const ref_options options = ref_options_from(&r.desc);
    for (size_t i = 0; i < count; i++) { // redraw until no per-splat decision is near its threshold
        gsf_splats one = r.splats;
        double near_margin, kink_margin, official_margin;
        do {
            random_splat(&r.splats, i, r.what, pixel, &state);
            one.count = 1;
            one.means = r.splats.means + 3 * i;
            one.log_scales = r.splats.log_scales + 3 * i;
            one.quats = r.splats.quats + 4 * i;
            one.opacity_logits = r.splats.opacity_logits + i;
            one.sh = r.splats.sh + 3 * (size_t)gsf_splat_count_sh(degree) * i;
            ref_splats wide = ref_splats_from(&one);
            ref_options visible = options;
            visible.hidden = NULL;
            const ref_projected p = ref_project(&wide, &r.camera, &visible, 0);
            near_margin = p.near_margin;
            kink_margin = p.kink_margin;
            official_margin = options.official_footprint ? p.official_margin : INFINITY;
            ref_destroy_splats(&wide);
        } while (near_margin < 1e-4 || kink_margin < 1e-4 || official_margin < 2e-5);
    }
    snprintf(r.label, sizeof r.label, "scene %llu (%s, %dx%d, %zu splats%s%s%s)", (unsigned long long)seed,
             kind_names[r.what], (int)size[0], (int)size[1], count, r.desc.antialiased ? ", antialiased" : "",
             options.official_footprint ? ", official footprint" : "",
             options.official_gradient ? ", official gradient" : "");
    return r;
}

static void random_scene_free(gsf_context* ctx, random_scene* r) {
    gsf_splat_destroy(ctx, &r->splats);
    free(r->hidden);
}

// ---- properties ----------------------------------------------------------------

// Values do not depend on which outputs are requested: single outputs, planar views, accumulated gradients, only some of
// the gradients.
static void test_requests(machine* m, const random_scene* scene, const oracle* o, const result* whole) {
    gsf_context* ctx = &m->ctx;
    const int64_t W = scene->camera.width, H = scene->camera.height;
    float* planar = (float*)calloc(3 * whole->pixels + 1, sizeof(float));
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = packed_view(planar, &scene->camera, 3);
    out.color.stride_x = 4;
    out.color.stride_y = 4 * W;
    out.color.stride_c = 4 * W * H;
    CHECK_OK(ctx, gsf_splat_render(ctx, m->rasterizer, &scene->splats, &scene->camera, &scene->desc, &out));
    size_t wrong = 0;
    for (size_t i = 0; i < 3 * whole->pixels; i++) wrong += planar[i % 3 * whole->pixels + i / 3] != whole->color[i];
    CHECK(wrong == 0);
    memset(&out.color, 0, sizeof out.color);
    out.depth = packed_view(planar, &scene->camera, 1);
    CHECK_OK(ctx, gsf_splat_render(ctx, m->rasterizer, &scene->splats, &scene->camera, &scene->desc, &out));
    CHECK(memcmp(planar, whole->depth, whole->pixels * sizeof(float)) == 0);

    // only the means' gradient, accumulated twice
    const size_t n = scene->splats.count;
    float* d_color = narrow(o->l.d_color, 3 * o->pixels);
    float* d_depth = narrow(o->l.d_depth, o->pixels);
    float* d_alpha = narrow(o->l.d_alpha, o->pixels);
    float* means = (float*)calloc(3 * n + 1, sizeof(float));
    gsf_splat_grads some;
    memset(&some, 0, sizeof some);
    some.means = means;
    for (int twice = 0; twice < 2; twice++)
        CHECK_OK(ctx, gsf_splat_render_backward(ctx, m->rasterizer, &scene->splats, &scene->camera, &scene->desc,
                                                d_color, d_depth, d_alpha, &some));
    wrong = 0;
    for (size_t i = 0; i < 3 * n; i++) wrong += means[i] != 2 * whole->grads.means[i];
    CHECK(wrong == 0);
    free(d_color); free(d_depth); free(d_alpha); free(means); free(planar);
}

// After the first pass, forward and backward passes allocate no memory.
static void test_steady_memory(machine* m, const random_scene* scene, const oracle* o) {
    result r = render(m, &scene->splats, &scene->camera, &scene->desc, &o->l);
    result_free(&r);
    const size_t before = allocations;
    r = render(m, &scene->splats, &scene->camera, &scene->desc, &o->l);
    CHECK(allocations == before);
    result_free(&r);
}

// A splat with a NaN or infinity is treated as hidden, gradients included.
static void test_not_finite(machine* m, const random_scene* scene, const oracle* o) {
    const size_t n = scene->splats.count, K = (size_t)gsf_splat_count_sh(scene->splats.sh_degree);
    gsf_splats bad;
    CHECK_OK(&m->ctx, gsf_splat_make(&m->ctx, n, scene->splats.sh_degree, &bad));
    memcpy(bad.origin, scene->splats.origin, sizeof bad.origin);
    memcpy(bad.means, scene->splats.means, 3 * n * sizeof(float));
    memcpy(bad.log_scales, scene->splats.log_scales, 3 * n * sizeof(float));
    memcpy(bad.quats, scene->splats.quats, 4 * n * sizeof(float));
    memcpy(bad.opacity_logits, scene->splats.opacity_logits, n * sizeof(float));
    memcpy(bad.sh, scene->splats.sh, 3 * K * n * sizeof(float));
    uint8_t* hidden = (uint8_t*)calloc(n + 1, 1);
    if (scene->desc.hidden) memcpy(hidden, scene->desc.hidden, n);
    gsf_render_desc desc = scene->desc;
    desc.hidden = hidden;
    uint8_t* broken = (uint8_t*)calloc(n + 1, 1);
    for (size_t i = 0; i < n; i += 7) broken[i] = hidden[i] = 1;
    result expected = render(m, &scene->splats, &scene->camera, &desc, &o->l);
    const float values[3] = {NAN, INFINITY, -INFINITY};
    for (size_t i = 0, k = 0; i < n; i += 7, k++) {
        const float v = values[k % 3];
        switch (k / 3 % 5) {
            case 0: bad.means[3 * i + 1] = v; break;
            case 1: bad.log_scales[3 * i] = v; break;
            case 2: bad.quats[4 * i + 3] = v; break;
            case 3: bad.opacity_logits[i] = v; break;
            default: bad.sh[3 * K * i] = v; break;
        }
    }
    desc.hidden = scene->desc.hidden;
    result actual = render(m, &bad, &scene->camera, &desc, &o->l);
    CHECK(same_bits(&expected, &actual));
    result_free(&expected);
    result_free(&actual);
    free(hidden);
    free(broken);
    gsf_splat_destroy(&m->ctx, &bad);
}

// ---- main ----------------------------------------------------------------------

enum { RANDOM_SCENES = 90 };

typedef struct totals {
    worst golden, full, random, needles;
    size_t pixels, skipped, blends;
} totals;

// Renders with one worker in order (rasterizer reused from scene to scene) and with several out of order (fresh
// rasterizer).
static result render_both_ways(machine* m, const oracle* o) {
    result r = render(m, o->splats, o->camera, o->desc, &o->l);
    machine other;
    if (CHECK(machine_open(&other, m->ctx.cpu_level, 1))) {
        result again = render(&other, o->splats, o->camera, o->desc, &o->l);
        if (!CHECK(same_bits(&r, &again))) fprintf(stderr, "%s, %s: other workers, other bits\n", o->label, m->name);
        result_free(&again);
        machine_close(&other);
    }
    return r;
}

static void test_golden_scene(machine* levels, size_t level_count, const char* name, totals* t) {
    splat_golden g = splat_golden_open(name);
    for (size_t k = 0; k < level_count; k++)
        for (int official = 0; official < 2; official++) golden_scene(&levels[k], &g, official, &t->golden);
    gsf_render_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.sh_bands = g.sh_bands;
    for (int c = 0; c < 3; c++) desc.background[c] = (float)g.background[c];
    char label[96];
    snprintf(label, sizeof label, "full footprint %s", name);
    oracle o = oracle_make(label, &g.splats, &g.camera, &desc, g.d_color, 11);
    for (size_t k = 0; k < level_count; k++) {
        result r = render_both_ways(&levels[k], &o);
        oracle_compare(&o, levels[k].name, &r, &t->full);
        result_free(&r);
    }
    t->pixels += o.pixels;
    t->skipped += o.skipped;
    for (size_t i = 0; i < o.pixels; i++) t->blends += (size_t)o.image.blended[i];
    oracle_free(&o);
    splat_golden_close(&g);
}

static void test_random_scene(machine* levels, size_t level_count, uint64_t seed, totals* t) {
    gsf_context* ctx = &levels[0].ctx;
    random_scene scene = random_scene_make(ctx, seed);
    oracle o = oracle_make(scene.label, &scene.splats, &scene.camera, &scene.desc, NULL, seed);
    for (size_t k = 0; k < level_count; k++) {
        result r = render_both_ways(&levels[k], &o);
        oracle_compare(&o, levels[k].name, &r, scene.what == NEEDLES ? &t->needles : &t->random);
        if (seed < 9) {
            test_requests(&levels[k], &scene, &o, &r);
            test_steady_memory(&levels[k], &scene, &o);
            test_not_finite(&levels[k], &scene, &o);
        }
        result_free(&r);
    }
    t->pixels += o.pixels;
    t->skipped += o.skipped;
    for (size_t i = 0; i < o.pixels; i++) t->blends += (size_t)o.image.blended[i];
    if (o.pixels > 1000) CHECK(o.skipped < o.pixels / 4); // enough pixels are left to compare
    oracle_free(&o);
    random_scene_free(ctx, &scene);
}

static void print_worst(const char* name, const worst* w) {
    printf("%-44s image %.2g  alpha %.2g  depth %.2g  gradients %.2g of the tolerance\n", name, w->image, w->alpha,
           w->depth, w->gradient);
}

int main(void) {
    machine levels[MACHINES];
    const size_t level_count = machines_open(levels);
    totals t;
    memset(&t, 0, sizeof t);
    const test_names scenes = splat_golden_scenes();
    for (size_t k = 0; k < scenes.count; k++) test_golden_scene(levels, level_count, scenes.name[k], &t);
    for (uint64_t seed = 0; seed < RANDOM_SCENES; seed++) test_random_scene(levels, level_count, seed, &t);
    for (size_t k = 0; k < level_count; k++) machine_close(&levels[k]);
    print_worst("golden scenes, official footprint", &t.golden);
    print_worst("golden scenes, full footprint", &t.full);
    print_worst("random scenes", &t.random);
    print_worst("random scenes of needles", &t.needles);
    CHECK(t.blends > 2 * t.pixels); // the scenes are not nearly empty
    printf("%zu CPU levels, %zu pixels, %zu with an unclear decision, %.1f splats blended in each\n", level_count,
           t.pixels, t.skipped, (double)t.blends / (double)t.pixels);
    train_golden_checks();
    return test_report();
}
