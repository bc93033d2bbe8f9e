// test_stress.c - the rasterizer and the trainer where they could break: against the double-precision reference
// (reference_splat.h) on ill-conditioned scenes, and by properties that must hold bit for bit.
// gcc -O2 -std=c11 -I. -Itests tests/test_stress.c -lm
//
//     test_stress            every test, one line of its worst figures each
//     test_stress --json     the same, and on standard output only the table: one JSON object per scene and CPU level
//     test_stress --long     the long run with all its 30,000 iterations instead of 3,000
//
// A pixel is clear when the reference's yes/no decisions in it (alpha = 1/255 and 0.99, T = 1e-4) keep a margin of 1e-4
// (relative) and neighbours in its blending order differ by more than 1e-6 in depth: that is ten times what float32 can
// tell apart, and the fewest pixels are excused. Only clear pixels have loss weights, so gradients are compared under the
// same decisions. Limits of ordinary scenes: see `ordinary`.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"
#include "reference_splat.h"
#include "splat_run.h"

#define MARGIN 1e-4
#define DEPTH_GAP 1e-6

static machine levels[MACHINES];
static size_t level_count;

// ---- the table -----------------------------------------------------------------

typedef struct row { // worst errors of one scene at one CPU level; -1 = not measured
    const char *test, *level;
    char name[64];
    size_t pixels, unclear;   // unclear: with a decision that float32 may take otherwise
    double clear_error;       // largest |colour or alpha - reference|, colour over max(1, brightest)
    double unclear_error;
    double depth_error;       // of clear pixels, relative to the largest depth
    double gradient;          // relative L2 of the worst parameter tensor
    double loosest;           // the largest share of a limit that an error took
} row;

static row* rows;
static size_t row_count, row_capacity;

static row* add_row(const char* test, const char* name, const char* level) {
    if (row_count == row_capacity) {
        row_capacity = 2 * row_capacity + 64;
        rows = (row*)realloc(rows, row_capacity * sizeof(row));
        if (!rows) exit(2);
    }
    row* r = &rows[row_count++];
    memset(r, 0, sizeof *r);
    r->test = test;
    r->level = level;
    snprintf(r->name, sizeof r->name, "%s", name);
    r->clear_error = r->unclear_error = r->depth_error = r->gradient = -1;
    return r;
}

static void print_number(const char* name, double value) {
    if (value < 0) printf(", \"%s\": null", name);
    else if (value <= 1e300) printf(", \"%s\": %.4g", name, value);
    else printf(", \"%s\": \"%f\"", name, value); // nan, inf: not numbers in JSON
}

static void print_table(void) {
    for (size_t i = 0; i < row_count; i++) {
        const row* r = &rows[i];
        printf("{\"test\": \"%s\", \"case\": \"%s\", \"level\": \"%s\", \"pixels\": %zu, \"unclear\": %zu", r->test,
               r->name, r->level, r->pixels, r->unclear);
        print_number("clear_error", r->clear_error);
        print_number("unclear_error", r->unclear_error);
        print_number("depth_error", r->depth_error);
        print_number("gradient", r->gradient);
        printf("}\n");
    }
}

static double now(void) {
    struct timespec t;
    timespec_get(&t, TIME_UTC);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// One line: what the rows from `first` on have as their worst.
static void print_worst(FILE* out, const char* test, size_t first, double seconds) {
    row worst;
    memset(&worst, 0, sizeof worst);
    worst.clear_error = worst.unclear_error = worst.depth_error = worst.gradient = -1;
    for (size_t i = first; i < row_count; i++) {
        worst.pixels += rows[i].pixels;
        worst.unclear += rows[i].unclear;
        worst.clear_error = nan_max(worst.clear_error, rows[i].clear_error);
        worst.unclear_error = nan_max(worst.unclear_error, rows[i].unclear_error);
        worst.depth_error = nan_max(worst.depth_error, rows[i].depth_error);
        worst.gradient = nan_max(worst.gradient, rows[i].gradient);
    }
    fprintf(out, "%-12s %4zu rows %8zu pixels", test, row_count - first, worst.pixels);
    if (worst.clear_error >= 0) fprintf(out, "  clear %.2e", worst.clear_error);
    if (worst.unclear) fprintf(out, "  unclear %zu (%.2e)", worst.unclear, worst.unclear_error);
    if (worst.depth_error >= 0) fprintf(out, "  depth %.2e", worst.depth_error);
    if (worst.gradient >= 0) fprintf(out, "  gradient %.2e", worst.gradient);
    fprintf(out, "  %.2f s\n", seconds);
}

// ---- scenes --------------------------------------------------------------------

// Splats are drawn in the camera's image: u, v evenly over a little more than the picture, z over a range.
typedef struct recipe { // zero = the default in brackets
    const char* name;
    size_t count;                 // [200]
    int32_t width, height;        // [120 x 80]
    double focal;                 // over the longer side [1]
    double z_low, z_high;         // [2, 5]; even where z_low is negative, else logarithmic
    double size_low, size_high;   // longest axis in pixels at the splat's own depth [1, 15]
    double aspect_low, aspect_high; // longest over shortest axis [1, 5]
    int shape;                    // 0: the middle axis anywhere between, 1: needles, 2: pancakes
    double logit_low, logit_high; // [-3, 4]
    double near_plane;            // [0.2]
    double origin;                // the splats' origin is at (1, -0.7, 0.3) times this
    int32_t sh_degree;            // [0]; 1..3
    int antialiased, official;
    uint64_t seed;
} recipe;

typedef struct limits {
    double clear, unclear, share, gradient; // share: of unclear pixels
} limits;

// The default quality that is promised.
static const limits ordinary = {2e-5, 8e-3, 1e-3, 2e-4};
// The same where many large splats lie over each other: every blend makes about 1e-4 of the pixels unclear, so their number
// says nothing about the rasterizer.
static const limits crowded = {2e-5, 8e-3, 1, 2e-4};

typedef struct scene {
    gsf_splats splats;
    gsf_camera camera;
    gsf_render_desc desc;
    const char* name;
    int exact_ties; // depths are either the same number or far apart: order is never unclear
} scene;

static double or_default(double value, double fallback) { return value != 0 ? value : fallback; }

static ref_projected project_one(const scene* s, size_t i) {
    gsf_splats one = s->splats;
    one.count = 1;
    one.means += 3 * i;
    one.log_scales += 3 * i;
    one.quats += 4 * i;
    one.opacity_logits += i;
    one.sh += 3 * (size_t)gsf_splat_sh_count(one.sh_degree) * i;
    ref_splats wide = ref_splats_from(&one);
    ref_options options = ref_options_from(&s->desc);
    options.hidden = NULL;
    const ref_projected p = ref_project(&wide, &s->camera, &options, 0);
    ref_destroy_splats(&wide);
    return p;
}

static void draw_splat(scene* s, const recipe* r, size_t i, uint64_t* state) {
    const gsf_camera* c = &s->camera;
    const double z_low = or_default(r->z_low, 2), z_high = or_default(r->z_high, 5);
    const double z = z_low > 0 ? random_log(state, z_low, z_high) : test_random_in(state, z_low, z_high);
    const double reach = fmax(fabs(z), 0.02 * z_high);
    const double p[3] = {(test_random_in(state, -0.1, 1.1) * c->width - c->cx) / c->fx * reach,
                         (test_random_in(state, -0.1, 1.1) * c->height - c->cy) / c->fy * reach, z};
    for (int a = 0; a < 3; a++) { // mean = R^T (p - t), t in coordinates relative to the origin
        double sum = 0;
        for (int k = 0; k < 3; k++) {
            double t = c->w2c[12 + k];
            for (int b = 0; b < 3; b++) t += c->w2c[4 * b + k] * s->splats.origin[b];
            sum += c->w2c[4 * a + k] * (p[k] - t);
        }
        s->splats.means[3 * i + (size_t)a] = (float)sum;
    }
    const double size = random_log(state, or_default(r->size_low, 1), or_default(r->size_high, 15)) * reach / c->fx;
    const double aspect = random_log(state, or_default(r->aspect_low, 1), or_default(r->aspect_high, 5));
    const double share = r->shape == 1 ? 1 : r->shape == 2 ? 0 : test_random(state);
    for (size_t k = 0; k < 3; k++) {
        const size_t axis = (i + k) % 3;
        s->splats.log_scales[3 * i + axis] = (float)(log(size) - (k == 0 ? 0 : k == 1 ? share : 1) * log(aspect));
    }
    double q[4], norm;
    do {
        for (int k = 0; k < 4; k++) q[k] = test_random_in(state, -1, 1);
        norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    } while (norm < 0.2);
    for (size_t k = 0; k < 4; k++) s->splats.quats[4 * i + k] = (float)q[k];
    s->splats.opacity_logits[i] =
        (float)test_random_in(state, or_default(r->logit_low, -3), or_default(r->logit_high, 4));
    const size_t K = (size_t)gsf_splat_sh_count(s->splats.sh_degree);
    for (size_t k = 0; k < 3 * K; k++)
        s->splats.sh[3 * K * i + k] = (float)test_random_in(state, k < 3 ? -1.5 : -0.15, k < 3 ? 1.5 : 0.15);
}

// Whether a splat is drawn at all, and on which side of a kink of the gradient it is, are decisions, too: splats are drawn
// again until theirs are clear.
static void draw_clear_splat(scene* s, const recipe* r, size_t i, uint64_t* state) {
    for (int attempt = 0; attempt < 1000; attempt++) {
        draw_splat(s, r, i, state);
        const ref_projected p = project_one(s, i);
        const double official = s->desc.footprint == GSF_FOOTPRINT_OFFICIAL ? p.official_margin : INFINITY;
        if (p.near_margin > 1e-4 && (!p.visible || p.kink_margin > 1e-4) && official > 2e-5) return;
    }
    CHECK(!"a splat with clear decisions");
}

static scene scene_make(const recipe* r) {
    scene s;
    memset(&s, 0, sizeof s);
    uint64_t state = r->seed * 977 + 5;
    s.name = r->name;
    CHECK_OK(&levels[0].ctx, gsf_splat_make(&levels[0].ctx, r->count ? r->count : 200, r->sh_degree, &s.splats));
    const double direction[3] = {1, -0.7, 0.3};
    for (int a = 0; a < 3; a++) s.splats.origin[a] = r->origin * direction[a];
    const double middle = 0.5 * (fmax(r->z_low, 0) + or_default(r->z_high, 5));
    s.camera = random_camera(&state, r->width ? r->width : 120, r->height ? r->height : 80, s.splats.origin, middle);
    const double longer = s.camera.width > s.camera.height ? s.camera.width : s.camera.height;
    s.camera.fx = longer * or_default(r->focal, 1);
    s.camera.fy = s.camera.fx * 1.05;
    for (int c = 0; c < 3; c++) s.desc.background[c] = (float)test_random_in(&state, 0.1, 1);
    s.desc.near_plane = (float)r->near_plane;
    s.desc.antialiased = r->antialiased;
    s.desc.footprint = r->official ? GSF_FOOTPRINT_OFFICIAL : GSF_FOOTPRINT_FULL;
    s.desc.gradient = r->official ? GSF_GRADIENT_OFFICIAL : GSF_GRADIENT_TRUE;
    for (size_t i = 0; i < s.splats.count; i++) draw_clear_splat(&s, r, i, &state);
    return s;
}

static void scene_free(scene* s) { gsf_splat_destroy(&levels[0].ctx, &s->splats); }

// ---- a scene against the reference ---------------------------------------------

typedef struct oracle {
    const scene* s;
    ref_image image;
    ref_grads grads;
    loss l;
    double* quat_norm; // quaternion gradients are compared times |q|: small quaternions do not hide the others
    uint8_t* skip;     // unclear pixels
    size_t pixels, unclear;
    double brightest, farthest;
} oracle;

static oracle oracle_make(const scene* s) {
    oracle o;
    memset(&o, 0, sizeof o);
    o.s = s;
    ref_splats wide = ref_splats_from(&s->splats);
    const ref_options options = ref_options_from(&s->desc);
    o.image = ref_render(&wide, &s->camera, &options);
    o.pixels = (size_t)s->camera.width * (size_t)s->camera.height;
    uint64_t state = 17;
    o.l.d_color = random_values(&state, 3 * o.pixels, 1);
    o.l.d_depth = random_values(&state, o.pixels, 0.2);
    o.l.d_alpha = random_values(&state, o.pixels, 1);
    o.skip = (uint8_t*)calloc(o.pixels + 1, 1);
    o.brightest = 1;
    for (size_t i = 0; i < o.pixels; i++) {
        for (size_t c = 0; c < 3; c++) o.brightest = fmax(o.brightest, fabs(o.image.color[3 * i + c]));
        o.farthest = fmax(o.farthest, o.image.depth[i]);
    }
    for (size_t i = 0; i < o.pixels; i++) {
        // Expected depth is a quotient by alpha, which float32 knows to 6e-8: its gradient fades with alpha, as that of a
        // loss that does not ask for the depth of nothing. Depths are measured in units of the farthest.
        o.l.d_depth[i] = (double)(float)(o.l.d_depth[i] * (1 - o.image.T[i]) / fmax(o.farthest, 1e-30));
        o.skip[i] = o.image.margin[i] < MARGIN || (!s->exact_ties && o.image.depth_gap[i] < DEPTH_GAP);
        if (!o.skip[i]) continue;
        o.unclear++;
        for (size_t c = 0; c < 3; c++) o.l.d_color[3 * i + c] = 0;
        o.l.d_depth[i] = o.l.d_alpha[i] = 0;
    }
    o.quat_norm = (double*)malloc((wide.count + 1) * sizeof(double));
    for (size_t i = 0; i < wide.count; i++) {
        const double* q = wide.quats + 4 * i;
        o.quat_norm[i] = fmax(sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), 1e-12);
    }
    o.grads = ref_make_grads(wide.count, wide.sh_count);
    ref_render_backward(&wide, &s->camera, &options, &o.image, o.l.d_color, o.l.d_depth, o.l.d_alpha, &o.grads);
    ref_destroy_splats(&wide);
    return o;
}

static void oracle_free(oracle* o) {
    ref_destroy_image(&o->image);
    ref_destroy_grads(&o->grads);
    free(o->l.d_color); free(o->l.d_depth); free(o->l.d_alpha);
    free(o->skip); free(o->quat_norm);
}

// Norms of expected and of actual - expected.
static void difference(const float* actual, const double* expected, size_t count, size_t width, const double* scale,
                       double* size, double* error) {
    *size = *error = 0;
    for (size_t i = 0; i < count * width; i++) {
        const double by = scale ? scale[i / width] : 1, e = ((double)actual[i] - expected[i]) * by;
        *size += expected[i] * by * expected[i] * by;
        *error += e * e;
    }
    *size = sqrt(*size);
    *error = sqrt(*error);
}

// Relative L2 of the worst parameter tensor. Log-scales and quaternions have the same unit; where all splats are round the
// gradient of the quaternions vanishes, so it counts as at least a hundredth of that of the scales.
static double gradient_error(const oracle* o, const result* r) {
    const size_t n = o->s->splats.count;
    const struct { const float* actual; const double* expected; size_t rows, width; } list[] = {
        {r->grads.log_scales, o->grads.log_scales, n, 3}, {r->grads.quats, o->grads.quats, n, 4},
        {r->grads.means, o->grads.means, n, 3},           {r->grads.opacity_logits, o->grads.logits, n, 1},
        {r->grads.sh, o->grads.sh, n, r->sh_floats},      {r->grads.means2d, o->grads.means2d, n, 2},
        {r->grads.means2d_abs, o->grads.means2d_abs, n, 2}, {r->grads.background, o->grads.background, 1, 3},
    };
    double worst = 0, size, error, scales = 0;
    for (size_t k = 0; k < sizeof list / sizeof list[0]; k++) {
        difference(list[k].actual, list[k].expected, list[k].rows, list[k].width, k == 1 ? o->quat_norm : NULL, &size,
                   &error);
        if (k == 0) scales = size;
        if (k == 1) size = fmax(size, 0.01 * scales);
        if (getenv("STRESS_DETAIL")) fprintf(stderr, "  %zu: %.2e of %.2e\n", k, error, size);
        worst = nan_max(worst, error == 0 ? 0 : error / size);
    }
    return worst;
}

static void check_limit(const row* r, const char* what, double error, double limit) {
    if (!CHECK(error <= limit))
        fprintf(stderr, "%s, %s, %s: %s %.3g, allowed %.3g\n", r->test, r->name, r->level, what, error, limit);
}

static void compare(const char* test, const oracle* o, const machine* m, const result* r, const limits* allowed) {
    row* w = add_row(test, o->s->name, m->name);
    w->pixels = o->pixels;
    w->unclear = o->unclear;
    w->clear_error = w->depth_error = 0;
    if (o->unclear) w->unclear_error = 0;
    for (size_t i = 0; i < o->pixels; i++) {
        double* error = o->skip[i] ? &w->unclear_error : &w->clear_error;
        for (size_t c = 0; c < 3; c++)
            *error = nan_max(*error, fabs((double)r->color[3 * i + c] - o->image.color[3 * i + c]) / o->brightest);
        *error = nan_max(*error, fabs((double)r->alpha[i] - (1 - o->image.T[i])));
        if (!o->skip[i])
            w->depth_error =
                nan_max(w->depth_error, fabs((double)r->depth[i] - o->image.depth[i]) / fmax(o->farthest, 1e-30));
    }
    w->gradient = gradient_error(o, r);
    check_limit(w, "clear pixels are off by", w->clear_error, allowed->clear);
    check_limit(w, "depths of clear pixels are off by", w->depth_error, 2.5 * allowed->clear);
    if (o->unclear) check_limit(w, "unclear pixels are off by", w->unclear_error, allowed->unclear);
    check_limit(w, "unclear pixels:", (double)o->unclear, ceil(allowed->share * (double)o->pixels));
    check_limit(w, "gradients are off by", w->gradient, allowed->gradient);
}

static void check_scene(const char* test, const scene* s, const limits* allowed) {
    oracle o = oracle_make(s);
    for (size_t k = 0; k < level_count; k++) {
        result r = render(&levels[k], &s->splats, &s->camera, &s->desc, &o.l);
        compare(test, &o, &levels[k], &r, allowed);
        result_free(&r);
    }
    oracle_free(&o);
}

static void check_recipes(const char* test, const recipe* list, size_t count, const limits* allowed) {
    for (size_t k = 0; k < count; k++) {
        recipe r = list[k];
        if (!r.seed) r.seed = k + 1;
        scene s = scene_make(&r);
        check_scene(test, &s, allowed);
        scene_free(&s);
    }
}

#define COUNT(array) (sizeof(array) / sizeof((array)[0]))

// ---- shapes, depths, sizes, opacities ------------------------------------------

static recipe shape_recipe(const char* name, double aspect, int shape, double size_high) {
    recipe r;
    memset(&r, 0, sizeof r);
    r.name = name;
    r.shape = shape;
    r.aspect_low = 0.5 * aspect;
    r.aspect_high = aspect;
    r.size_low = 10;
    r.size_high = size_high;
    return r;
}

static void test_shapes(void) {
    const recipe list[] = {
        shape_recipe("needles 1e2", 1e2, 1, 100),   shape_recipe("needles 1e4", 1e4, 1, 100),
        shape_recipe("needles 1e6", 1e6, 1, 100),   shape_recipe("pancakes 1e2", 1e2, 2, 30),
        shape_recipe("pancakes 1e4", 1e4, 2, 30),   shape_recipe("pancakes 1e6", 1e6, 2, 30),
        shape_recipe("long needles 1e4", 1e4, 1, 1e3), shape_recipe("long needles 1e6", 1e6, 1, 1e3),
    };
    check_recipes("shapes", list, COUNT(list), &ordinary);
}

static void test_depths(void) {
    const recipe list[] = {
        {.name = "across the near plane", .z_low = -0.5, .z_high = 1.5, .count = 300},
        {.name = "just beyond the near plane", .z_low = 0.2001, .z_high = 0.25},
        {.name = "all behind", .z_low = -5, .z_high = -0.01},
        {.name = "1e6 away", .z_low = 0.9e6, .z_high = 1.1e6},
        {.name = "from 0.3 to 1e6", .z_low = 0.3, .z_high = 1e6},
        {.name = "from 0.3 to 1e6, tele", .z_low = 0.3, .z_high = 1e6, .focal = 30},
    };
    check_recipes("depths", list, COUNT(list), &ordinary);
}

static void test_sizes(void) {
    const recipe list[] = {
        {.name = "ten images wide", .size_low = 500, .size_high = 1500, .logit_high = 1},
        {.name = "1e4 images wide", .size_low = 1e5, .size_high = 1e6, .logit_high = 1},
        {.name = "far below a pixel", .size_low = 1e-5, .size_high = 0.1, .count = 2000},
        {.name = "far below a pixel, antialiased", .size_low = 0.02, .size_high = 0.5, .count = 2000, .antialiased = 1},
        {.name = "all sizes", .size_low = 1e-4, .size_high = 1e4, .count = 300},
        {.name = "all sizes, antialiased", .size_low = 1e-4, .size_high = 1e4, .count = 300, .antialiased = 1},
    };
    check_recipes("sizes", list, COUNT(list), &ordinary);
}

static void test_opacities(void) {
    const recipe list[] = {
        {.name = "logits -20..20", .logit_low = -20, .logit_high = 20, .count = 400},
        {.name = "logits 15..20", .logit_low = 15, .logit_high = 20},
        {.name = "logits -20..-15", .logit_low = -20, .logit_high = -15},
        {.name = "logits -5.6..-5.4", .logit_low = -5.6, .logit_high = -5.4, .count = 600}, // around 1/255
        {.name = "logits 4.5..4.7", .logit_low = 4.5, .logit_high = 4.7},                   // around 0.99
        {.name = "logits -20..20, antialiased", .logit_low = -20, .logit_high = 20, .count = 400, .antialiased = 1},
    };
    check_recipes("opacities", list, COUNT(list), &ordinary);
}

// ---- stacks, quaternions, offsets, ties, image sizes, values that are no numbers ---

// `count` splats of one pixel's width up to several images, one behind the other, opacities as the recipe says.
static void test_stacks(void) {
    const recipe list[] = {
        {.name = "5000 layers of 0.0043", .logit_low = -5.45, .logit_high = -5.44, .count = 5000},
        {.name = "5000 layers of 0.006..0.02", .logit_low = -5.1, .logit_high = -3.9, .count = 5000},
        {.name = "5000 layers below 1/255", .logit_low = -9, .logit_high = -5.6, .count = 5000},
        {.name = "5000 layers of 0.9..1", .logit_low = 2.2, .logit_high = 12, .count = 5000},
        {.name = "5000 layers of any opacity", .logit_low = -12, .logit_high = 6, .count = 5000},
    };
    for (size_t k = 0; k < COUNT(list); k++) {
        recipe r = list[k];
        r.seed = k + 1;
        r.width = 24;
        r.height = 20;
        r.size_low = 30;
        r.size_high = 300;
        r.z_high = 9;
        scene s = scene_make(&r);
        check_scene("stacks", &s, &crowded);
        scene_free(&s);
    }
}

static void test_quaternions(void) {
    recipe r;
    memset(&r, 0, sizeof r);
    r.seed = 3;
    r.count = 300;
    r.name = "lengths 1e-6..1e6, zero";
    scene s = scene_make(&r);
    uint64_t state = 8;
    for (size_t i = 0; i < s.splats.count; i++) {
        float* q = s.splats.quats + 4 * i;
        const double length = i % 10 == 0 ? 0 : random_log(&state, 1e-6, 1e6);
        for (int k = 0; k < 4; k++) q[k] = (float)((double)q[k] * length);
        if (i % 10 == 1) q[1] = q[2] = q[3] = 0;
    }
    check_scene("quaternions", &s, &ordinary);
    scene_free(&s);
    r.shape = 1;
    r.aspect_low = r.aspect_high = 1e3;
    r.name = "the same of needles";
    s = scene_make(&r);
    for (size_t i = 0; i < s.splats.count; i++)
        for (size_t k = 0; k < 4; k++) s.splats.quats[4 * i + k] *= i % 2 ? 1e-6f : 1e6f;
    check_scene("quaternions", &s, &ordinary);
    scene_free(&s);
}

static void test_offsets(void) {
    const recipe list[] = {
        {.name = "1e5 from zero", .origin = 1e5, .sh_degree = 3},
        {.name = "1e6 from zero", .origin = 1e6, .sh_degree = 3},
        {.name = "1e6 from zero, needles", .origin = 1e6, .shape = 1, .aspect_low = 1e3, .aspect_high = 1e4,
         .size_high = 60},
    };
    check_recipes("offsets", list, COUNT(list), &ordinary);
}

// Depths are multiples of 1/16 and the camera looks along z: many are the same number in float32 as in float64, and among
// these the order is that of the indices. Turned round in memory, the splats make another picture.
static void test_ties(void) {
    recipe r;
    memset(&r, 0, sizeof r);
    r.name = "depths of 48 values";
    r.seed = 5;
    r.count = 400;
    scene s = scene_make(&r);
    memset(s.camera.w2c, 0, sizeof s.camera.w2c);
    for (int k = 0; k < 4; k++) s.camera.w2c[5 * k] = 1;
    s.camera.w2c[14] = 3.5;
    uint64_t state = 4;
    for (size_t i = 0; i < s.splats.count; i++) {
        draw_clear_splat(&s, &r, i, &state);
        s.splats.means[3 * i + 2] = (float)floor(16 * (double)s.splats.means[3 * i + 2]) / 16;
    }
    s.exact_ties = 1;
    check_scene("ties", &s, &ordinary);

    const size_t n = s.splats.count;
    gsf_splats turned;
    CHECK_OK(&levels[0].ctx, gsf_splat_make(&levels[0].ctx, n, 0, &turned));
    for (size_t i = 0; i < n; i++) {
        const size_t j = n - 1 - i;
        memcpy(turned.means + 3 * i, s.splats.means + 3 * j, 3 * sizeof(float));
        memcpy(turned.log_scales + 3 * i, s.splats.log_scales + 3 * j, 3 * sizeof(float));
        memcpy(turned.quats + 4 * i, s.splats.quats + 4 * j, 4 * sizeof(float));
        turned.opacity_logits[i] = s.splats.opacity_logits[j];
        memcpy(turned.sh + 3 * i, s.splats.sh + 3 * j, 3 * sizeof(float));
    }
    scene t = s;
    t.splats = turned;
    t.name = "the same turned round";
    oracle a = oracle_make(&s), b = oracle_make(&t);
    double change = 0;
    for (size_t i = 0; i < 3 * a.pixels; i++) change = fmax(change, fabs(a.image.color[i] - b.image.color[i]));
    CHECK(change > 0.1);
    oracle_free(&a);
    oracle_free(&b);
    check_scene("ties", &t, &ordinary);
    scene_free(&t);
    scene_free(&s);
}

static void test_image_sizes(void) {
    const recipe list[] = {
        {.name = "1x1", .width = 1, .height = 1, .size_high = 3},
        {.name = "1x17", .width = 1, .height = 17, .count = 60},
        {.name = "33x1", .width = 33, .height = 1, .count = 60},
        {.name = "15x16", .width = 15, .height = 16},
        {.name = "17x33", .width = 17, .height = 33},
        {.name = "480x270", .width = 480, .height = 270, .size_low = 0.3, .count = 1500},
        {.name = "1920x16", .width = 1920, .height = 16, .size_low = 0.3, .count = 1500},
        {.name = "8192x16", .width = 8192, .height = 16, .size_low = 0.3, .count = 3000},
    };
    check_recipes("image sizes", list, COUNT(list), &ordinary);
}

// ---- main ----------------------------------------------------------------------

typedef struct test_entry { const char* name; void (*run)(void); } test_entry;

int main(int argc, char** argv) {
    static const test_entry tests[] = {
        {"shapes", test_shapes}, {"depths", test_depths}, {"sizes", test_sizes}, {"opacities", test_opacities},
        {"stacks", test_stacks}, {"quaternions", test_quaternions}, {"offsets", test_offsets}, {"ties", test_ties},
        {"image sizes", test_image_sizes},
    };
    int json = 0;
    const char* only = NULL;
    for (int i = 1; i < argc; i++) {
        if (strcmp(argv[i], "--json") == 0) json = 1;
        else only = argv[i];
    }
    FILE* out = json ? stderr : stdout;
    level_count = machines_open(levels);
    for (size_t k = 0; k < COUNT(tests); k++) {
        if (only && strcmp(only, tests[k].name) != 0) continue;
        const size_t first = row_count;
        const double start = now();
        tests[k].run();
        print_worst(out, tests[k].name, first, now() - start);
    }
    for (size_t k = 0; k < level_count; k++) machine_close(&levels[k]);
    if (json) print_table();
    fprintf(out, "%d checks, %d failed\n", test_checks, test_failures);
    free(rows);
    return test_failures ? 1 : 0;
}
