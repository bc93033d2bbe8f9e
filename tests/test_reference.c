// test_reference.c - the double-precision reference renderer (reference_splat.h) against the golden scenes, and its
// gradients against central differences.
#include "gsfixer_splat.h"
#include "test.h"
#include "reference_splat.h"
#include "splat_golden.h"

// ---- golden data ---------------------------------------------------------------

// |actual - expected| <= tolerance times the largest |expected|.
static void compare_relative(const char* scene, const char* what, const double* actual, const test_tensor* expected,
                             double tolerance) {
    char label[160];
    snprintf(label, sizeof label, "%s %s", scene, what);
    test_compare(label, actual, expected->v, expected->count, tolerance * test_max_abs(expected->v, expected->count));
}

static void check_counts(const splat_golden* g, const ref_image* image) {
    test_tensor blended = test_get_tensor(&g->file, "out.n_blended"), radii = test_get_tensor(&g->file, "out.radii");
    test_tensor order = test_get_tensor(&g->file, "out.order"), rect = test_get_tensor(&g->file, "out.tile_rect");
    size_t wrong = 0;
    for (size_t i = 0; i < g->pixels; i++) wrong += image->blended[i] != (int32_t)blended.v[i];
    for (size_t i = 0; i < g->splats.count; i++) {
        wrong += image->splats[i].radius != (int64_t)radii.v[i];
        for (int k = 0; k < 4; k++) wrong += image->splats[i].rect[k] != (int)rect.v[4 * i + k];
    }
    CHECK(image->order_count == order.count);
    for (size_t k = 0; k < order.count && k < image->order_count; k++) wrong += image->order[k] != (uint32_t)order.v[k];
    if (!CHECK(wrong == 0)) fprintf(stderr, "%s: %zu counts differ\n", g->name, wrong);
    test_free_tensor(&blended); test_free_tensor(&radii); test_free_tensor(&order); test_free_tensor(&rect);
}

// Per-splat tensor (count, n) of doubles at `offset` in ref_projected.
static void check_projected(const splat_golden* g, const ref_image* image, const char* name, size_t offset, size_t n) {
    test_tensor expected = test_get_tensor(&g->file, name);
    double* actual = (double*)malloc((expected.count + 1) * sizeof(double));
    for (size_t i = 0; i < g->splats.count; i++)
        memcpy(actual + n * i, (const char*)&image->splats[i] + offset, n * sizeof(double));
    double worst = 0; // relative: stored in double
    for (size_t i = 0; i < expected.count; i++)
        worst = fmax(worst, fabs(actual[i] - expected.v[i]) / fmax(fabs(expected.v[i]), 1e-6));
    if (!CHECK(expected.count == n * g->splats.count && worst <= 1e-8))
        fprintf(stderr, "%s %s: relative error %.3g\n", g->name, name, worst);
    free(actual);
    test_free_tensor(&expected);
}

static void check_gradients(const splat_golden* g, const ref_splats* s, const ref_grads* grads, int official) {
    const struct { const char* name; const double* actual; } list[] = {
        {"means", grads->means}, {"scales_log", grads->log_scales}, {"quats_raw", grads->quats},
        {"opacity_logit", grads->logits}, {"sh", grads->sh}, {"means2d_pix", grads->means2d},
    };
    for (size_t k = 0; k < sizeof list / sizeof list[0]; k++) {
        test_tensor expected = splat_golden_gradient(g, official, list[k].name);
        compare_relative(g->name, list[k].name, list[k].actual, &expected, 1e-6);
        test_free_tensor(&expected);
    }
    test_tensor ndc = splat_golden_gradient(g, official, "means2d_ndc");
    double* scaled = (double*)malloc((ndc.count + 1) * sizeof(double));
    for (size_t i = 0; i < 2 * s->count; i++)
        scaled[i] = grads->means2d[i] * (i % 2 ? g->camera.height : g->camera.width) / 2.0;
    compare_relative(g->name, "means2d_ndc", scaled, &ndc, 1e-6);
    free(scaled);
    test_free_tensor(&ndc);
}

static void test_golden_scene(const char* name) {
    splat_golden g = splat_golden_open(name);
    ref_splats s = ref_splats_from(&g.splats);
    ref_options o;
    memset(&o, 0, sizeof o);
    o.official_footprint = 1;
    o.sh_bands = g.sh_bands;
    memcpy(o.background, g.background, sizeof o.background);

    ref_image image = ref_render(&s, &g.camera, &o);
    check_counts(&g, &image);
    check_projected(&g, &image, "out.means2d", offsetof(ref_projected, u), 2);
    check_projected(&g, &image, "out.cov2d_abc", offsetof(ref_projected, cov), 3);
    check_projected(&g, &image, "out.conic_abc", offsetof(ref_projected, conic), 3);
    check_projected(&g, &image, "out.depth_z", offsetof(ref_projected, z), 1);
    double* expected = splat_golden_image(&g, "out.image");
    char label[96];
    snprintf(label, sizeof label, "%s image", name);
    test_compare(label, image.color, expected, 3 * g.pixels, 2e-7);
    free(expected);
    const struct { const char* name; const double* actual; } planes[] = {
        {"out.T", image.T}, {"out.depth_expected", image.depth}, {"out.invdepth", image.inverse_depth}};
    for (int k = 0; k < 3; k++) {
        test_tensor plane = test_get_tensor(&g.file, planes[k].name);
        CHECK(plane.count == g.pixels);
        compare_relative(name, planes[k].name, planes[k].actual, &plane, 2e-7);
        test_free_tensor(&plane);
    }
    double margin = INFINITY; // the scenes were nudged away from all decisions
    for (size_t i = 0; i < g.pixels; i++) margin = fmin(margin, image.margin[i]);
    CHECK(margin >= 0.9e-4);

    for (int official = 0; official < 2; official++) {
        o.official_gradient = official;
        ref_grads grads = ref_make_grads(s.count, s.sh_count);
        ref_render_backward(&s, &g.camera, &o, &image, g.d_color, NULL, NULL, &grads);
        check_gradients(&g, &s, &grads, official);
        ref_destroy_grads(&grads);
    }
    ref_destroy_image(&image);

    double* untiled = splat_golden_image(&g, "notile.image");
    if (untiled) { // it holds only splats whose 3-sigma square touches the image
        test_tensor radii = test_get_tensor(&g.file, "out.radii");
        uint8_t* hidden = (uint8_t*)calloc(s.count + 1, 1);
        for (size_t i = 0; i < s.count; i++) hidden[i] = radii.v[i] == 0;
        o.official_footprint = 0;
        o.hidden = hidden;
        image = ref_render(&s, &g.camera, &o);
        snprintf(label, sizeof label, "%s image without tiles", name);
        test_compare(label, image.color, untiled, 3 * g.pixels, 2e-7);
        ref_destroy_image(&image);
        free(untiled);
        free(hidden);
        test_free_tensor(&radii);
    }
    ref_destroy_splats(&s);
    splat_golden_close(&g);
}

// ---- finite differences --------------------------------------------------------
// Loss = sum of random weights times colour, depth and alpha, over the pixels that are at least 1e-3 (relative) away
// from every yes/no decision and whose neighbours in depth are at least 1e-4 apart; splats keep 1e-3 from kinks (colour
// clamp, x/z clamp, near plane). Central differences with step 1e-5 (parameters are of order 1): the truncation error
// is about step^2 / 6 times the third derivative, the rounding error 1e-16 of the loss / step. Measured, relative to
// the largest gradient of each tensor: at most 4e-8, but 6e-7 for the logits of one scene. The tolerance is 1e-6.

enum { FD_WIDTH = 37, FD_HEIGHT = 23, FD_PIXELS = FD_WIDTH * FD_HEIGHT };
static const double fd_step = 1e-5, fd_tolerance = 1e-6;

typedef struct fd_case {
    ref_splats s;
    gsf_camera camera;
    ref_options o;
    double d_color[3 * FD_PIXELS], d_depth[FD_PIXELS], d_alpha[FD_PIXELS];
    double* offset2d;
} fd_case;

static double fd_loss(const fd_case* f) {
    ref_image image = ref_render(&f->s, &f->camera, &f->o);
    double loss = 0;
    for (size_t i = 0; i < FD_PIXELS; i++) {
        for (size_t c = 0; c < 3; c++) loss += f->d_color[3 * i + c] * image.color[3 * i + c];
        loss += f->d_depth[i] * image.depth[i] + f->d_alpha[i] * (1 - image.T[i]);
    }
    ref_destroy_image(&image);
    return loss;
}

static double fd_derivative(const fd_case* f, double* parameter) {
    const double kept = *parameter;
    *parameter = kept + fd_step;
    const double above = fd_loss(f);
    *parameter = kept - fd_step;
    const double below = fd_loss(f);
    *parameter = kept;
    return (above - below) / (2 * fd_step);
}

static void fd_check(const fd_case* f, const char* name, uint64_t seed, double* parameters, const double* gradient,
                     size_t count, int must_act) {
    double* numeric = (double*)malloc((count + 1) * sizeof(double));
    for (size_t i = 0; i < count; i++) numeric[i] = fd_derivative(f, parameters + i);
    const double size = test_max_abs(numeric, count);
    char label[96];
    snprintf(label, sizeof label, "finite differences, scene %llu, %s", (unsigned long long)seed, name);
    test_compare(label, gradient, numeric, count, fd_tolerance * size + 1e-9);
    if (must_act) CHECK(size > 1e-3);
    free(numeric);
}

// A rotation by random angles and a camera a few units in front of the origin.
static gsf_camera fd_random_camera(uint64_t* state) {
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    double q[4], unit[4], R[3][3];
    for (int k = 0; k < 4; k++) q[k] = test_random_in(state, -1, 1);
    ref_rotation(q, unit, R);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) camera.w2c[4 * c + r] = R[r][c];
    camera.w2c[12] = test_random_in(state, -0.3, 0.3);
    camera.w2c[13] = test_random_in(state, -0.3, 0.3);
    camera.w2c[14] = test_random_in(state, 2, 4);
    camera.w2c[15] = 1;
    camera.width = FD_WIDTH;
    camera.height = FD_HEIGHT;
    camera.fx = test_random_in(state, 25, 45);
    camera.fy = test_random_in(state, 25, 45);
    camera.cx = test_random_in(state, 15, 22);
    camera.cy = test_random_in(state, 9, 14);
    return camera;
}

// Redraws splat i until no kink or near plane is within 1e-3.
static void fd_random_splat(fd_case* f, size_t i, int opaque, uint64_t* state) {
    for (;;) {
        for (int k = 0; k < 3; k++) f->s.means[3 * i + k] = test_random_in(state, -1.6, 1.6);
        for (int k = 0; k < 3; k++) f->s.log_scales[3 * i + k] = test_random_in(state, -3.0, opaque ? -0.2 : -0.7);
        for (int k = 0; k < 4; k++) f->s.quats[4 * i + k] = test_random_in(state, -1.5, 1.5);
        f->s.logits[i] = opaque ? test_random_in(state, 2, 7) : test_random_in(state, -2, 2); // 0.99 is 4.6
        for (int k = 0; k < 3 * f->s.sh_count; k++)
            f->s.sh[3 * (size_t)f->s.sh_count * i + k] = test_random_in(state, -0.6, 0.6);
        const double* q = f->s.quats + 4 * i;
        if (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] < 0.2) continue;
        const ref_projected p = ref_project(&f->s, &f->camera, &f->o, i);
        if (p.near_margin > 1e-3 && p.kink_margin > 1e-3) return;
    }
}

// Sum over the pixels of |d loss(pixel) / d projected mean|: by differences pixel by pixel.
static void fd_check_absolute(fd_case* f, uint64_t seed, const double* gradient) {
    double* numeric = (double*)calloc(2 * f->s.count, sizeof(double));
    for (size_t k = 0; k < 2 * f->s.count; k++) {
        ref_image side[2];
        for (int sign = 0; sign < 2; sign++) {
            f->offset2d[k] = sign ? fd_step : -fd_step;
            side[sign] = ref_render(&f->s, &f->camera, &f->o);
        }
        f->offset2d[k] = 0;
        for (size_t i = 0; i < FD_PIXELS; i++) {
            double change = f->d_depth[i] * (side[1].depth[i] - side[0].depth[i]) -
                            f->d_alpha[i] * (side[1].T[i] - side[0].T[i]);
            for (size_t c = 0; c < 3; c++)
                change += f->d_color[3 * i + c] * (side[1].color[3 * i + c] - side[0].color[3 * i + c]);
            numeric[k] += fabs(change) / (2 * fd_step);
        }
        ref_destroy_image(&side[0]);
        ref_destroy_image(&side[1]);
    }
    char label[96];
    snprintf(label, sizeof label, "finite differences, scene %llu, means2d_abs", (unsigned long long)seed);
    test_compare(label, gradient, numeric, 2 * f->s.count, fd_tolerance * test_max_abs(numeric, 2 * f->s.count) + 1e-9);
    free(numeric);
}

typedef struct fd_seen { size_t saturated, stopped, clamped_ratio, dark; } fd_seen; // the branches that the scenes took

static void test_finite_differences(uint64_t seed, fd_seen* seen) {
    static const size_t counts[] = {1, 5, 14, 40};
    static fd_case f;
    memset(&f, 0, sizeof f);
    uint64_t state = seed;
    const int degree = (int)(seed % 4);
    f.camera = fd_random_camera(&state);
    f.s = ref_make_splats(counts[seed / 4 % 4], (degree + 1) * (degree + 1));
    f.o.antialiased = (int)(seed % 3 == 2);
    f.o.compensation_floor = seed % 2 ? 0.3 : 0; // high, so that both sides of it are met
    f.o.sh_bands = seed % 5 == 4 ? degree : 0;
    f.o.near_plane = seed % 2 ? 0.05 : 0;
    f.o.opacity_scale = seed % 3 == 1 ? 0.8 : 0;
    for (int c = 0; c < 3; c++) f.o.background[c] = test_random_in(&state, 0.1, 1);
    f.offset2d = (double*)calloc(2 * f.s.count, sizeof(double));
    f.o.offset2d = f.offset2d;
    for (size_t i = 0; i < f.s.count; i++) fd_random_splat(&f, i, seed % 2 == 1, &state);
    uint8_t* hidden = (uint8_t*)calloc(f.s.count, 1);
    if (f.s.count > 5) hidden[3] = 1;
    f.o.hidden = hidden;

    ref_image image = ref_render(&f.s, &f.camera, &f.o);
    size_t kept = 0;
    for (size_t i = 0; i < FD_PIXELS; i++) {
        const int safe = image.margin[i] > 1e-3 && image.depth_gap[i] > 1e-4;
        kept += (size_t)safe;
        for (size_t c = 0; c < 3; c++) f.d_color[3 * i + c] = safe ? test_random_in(&state, -1, 1) : 0;
        f.d_depth[i] = safe ? test_random_in(&state, -0.3, 0.3) : 0;
        f.d_alpha[i] = safe ? test_random_in(&state, -1, 1) : 0;
        seen->stopped += safe && image.T[i] < 1e-3;
    }
    CHECK(kept > FD_PIXELS / 2);
    for (size_t i = 0; i < f.s.count; i++) {
        const ref_geometry g = ref_geometry_of(&f.s, &f.camera, &f.o, i);
        const ref_projected* p = &image.splats[i];
        seen->saturated += p->visible && p->opacity * p->compensation > 0.995;
        seen->clamped_ratio += p->visible && (g.clamped[0] || g.clamped[1]) && p->box[2] > 0 && p->box[0] < FD_WIDTH;
        seen->dark += g.raw_color[0] < 0;
    }
    ref_grads g = ref_make_grads(f.s.count, f.s.sh_count);
    ref_render_backward(&f.s, &f.camera, &f.o, &image, f.d_color, f.d_depth, f.d_alpha, &g);
    ref_destroy_image(&image);

    const int act = f.s.count >= 14;
    fd_check(&f, "means", seed, f.s.means, g.means, 3 * f.s.count, act);
    fd_check(&f, "log_scales", seed, f.s.log_scales, g.log_scales, 3 * f.s.count, act);
    fd_check(&f, "quats", seed, f.s.quats, g.quats, 4 * f.s.count, act);
    fd_check(&f, "logits", seed, f.s.logits, g.logits, f.s.count, act);
    fd_check(&f, "sh", seed, f.s.sh, g.sh, 3 * (size_t)f.s.sh_count * f.s.count, act);
    fd_check(&f, "means2d", seed, f.offset2d, g.means2d, 2 * f.s.count, act);
    fd_check(&f, "background", seed, f.o.background, g.background, 3, 1);
    fd_check_absolute(&f, seed, g.means2d_abs);
    for (size_t i = 0; i < f.s.count; i++)
        if (hidden[i]) CHECK(g.logits[i] == 0 && g.means[3 * i] == 0);
    ref_destroy_grads(&g);
    ref_destroy_splats(&f.s);
    free(f.offset2d);
    free(hidden);
}

int main(void) {
    const test_names scenes = splat_golden_scenes();
    for (size_t k = 0; k < scenes.count; k++) test_golden_scene(scenes.name[k]);
    fd_seen seen;
    memset(&seen, 0, sizeof seen);
    for (uint64_t seed = 0; seed < 24; seed++) test_finite_differences(seed, &seen);
    CHECK(seen.saturated > 0 && seen.stopped > 0 && seen.clamped_ratio > 0 && seen.dark > 0);
    return test_report();
}
