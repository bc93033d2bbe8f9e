// splat_golden.h - the golden scenes of the rasterizer as gsf_splats and gsf_camera; for test_reference.c,
// golden_splat.c.
#ifndef SPLAT_GOLDEN_H
#define SPLAT_GOLDEN_H

#include "gsfixer_splat.h"
#include "test.h"

static inline test_names splat_golden_scenes(void) { return test_list_golden("splat/scenes", "", ".safetensors"); }

typedef struct splat_golden {
    const char* name;
    test_tensors file;
    gsf_splats splats;  // malloc'd arrays
    gsf_camera camera;
    int sh_bands;
    double background[3];
    size_t pixels;
    double* d_color;    // (H,W,3): grad.dL_dimage
    int fragile;        // some pixels lose up to 3 digits in float32, in the reference as well (out.fragile)
} splat_golden;

static inline float* splat_golden_floats(const test_tensors* file, const char* name) {
    test_tensor t = test_get_tensor(file, name);
    float* values = test_tensor_floats(&t);
    test_free_tensor(&t);
    return values;
}

// (3,H,W) to (H,W,3)
static inline double* splat_golden_interleave(const test_tensor* t) {
    const size_t plane = t->dim[1] * t->dim[2];
    double* out = (double*)malloc((t->count ? t->count : 1) * sizeof(double));
    for (size_t c = 0; c < 3; c++)
        for (size_t i = 0; i < plane; i++) out[3 * i + c] = t->v[c * plane + i];
    return out;
}

static inline splat_golden splat_golden_open(const char* name) {
    splat_golden g;
    memset(&g, 0, sizeof g);
    char relative[128];
    snprintf(relative, sizeof relative, "splat/scenes/%s.safetensors", name);
    g.name = name;
    g.file = test_open_tensors(test_golden(relative));
    test_tensor means = test_get_tensor(&g.file, "in.means"), sh = test_get_tensor(&g.file, "in.sh");
    test_tensor w2c = test_get_tensor(&g.file, "in.w2c"), K = test_get_tensor(&g.file, "in.K");
    test_tensor background = test_get_tensor(&g.file, "in.bg"), image = test_get_tensor(&g.file, "out.image");
    test_tensor d_image = test_get_tensor(&g.file, "grad.dL_dimage"), fragile = test_get_tensor(&g.file, "out.fragile");
    g.splats.count = means.dim[0];
    while ((size_t)gsf_splat_count_sh(g.splats.sh_degree) < sh.dim[1]) g.splats.sh_degree++;
    g.splats.means = test_tensor_floats(&means);
    g.splats.log_scales = splat_golden_floats(&g.file, "in.scales_log");
    g.splats.quats = splat_golden_floats(&g.file, "in.quats_wxyz_raw");
    g.splats.opacity_logits = splat_golden_floats(&g.file, "in.opacity_logit");
    g.splats.sh = test_tensor_floats(&sh);
    g.splats.ids = (uint32_t*)malloc((g.splats.count + 1) * sizeof(uint32_t));
    for (size_t i = 0; i < g.splats.count; i++) g.splats.ids[i] = (uint32_t)i;
    for (int r = 0; r < 4; r++)
        for (int c = 0; c < 4; c++) g.camera.w2c[4 * c + r] = w2c.v[4 * r + c];
    g.camera.fx = K.v[0]; g.camera.fy = K.v[4]; g.camera.cx = K.v[2]; g.camera.cy = K.v[5];
    g.camera.height = (int32_t)image.dim[1];
    g.camera.width = (int32_t)image.dim[2];
    g.pixels = image.dim[1] * image.dim[2];
    for (int c = 0; c < 3; c++) g.background[c] = background.v[c];
    const char* degree = test_metadata(&g.file, "sh_degree_active");
    g.sh_bands = degree ? atoi(degree) + 1 : 0;
    g.d_color = splat_golden_interleave(&d_image);
    g.fragile = test_max_abs(fragile.v, fragile.count) > 0.0;
    test_free_tensor(&means); test_free_tensor(&sh); test_free_tensor(&w2c); test_free_tensor(&K);
    test_free_tensor(&background); test_free_tensor(&image); test_free_tensor(&d_image);
    test_free_tensor(&fragile);
    return g;
}

static inline void splat_golden_close(splat_golden* g) {
    free(g->splats.means); free(g->splats.log_scales); free(g->splats.quats); free(g->splats.opacity_logits);
    free(g->splats.sh); free(g->splats.ids); free(g->d_color);
    test_close_tensors(&g->file);
}

// out.image or notile.image as (H,W,3), NULL when absent.
static inline double* splat_golden_image(const splat_golden* g, const char* name) {
    test_tensor t = test_find_tensor(&g->file, name);
    if (!t.v) return NULL;
    double* out = splat_golden_interleave(&t);
    test_free_tensor(&t);
    return out;
}

// Name of a gradient tensor: the SH gradient is the same in both variants and stored once.
static inline test_tensor splat_golden_gradient(const splat_golden* g, int official, const char* name) {
    char full[96];
    snprintf(full, sizeof full, "grad.%s.%s", official && strcmp(name, "sh") != 0 ? "inria" : "exact", name);
    return test_get_tensor(&g->file, full);
}

#endif
