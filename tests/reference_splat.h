// reference_splat.h - double-precision reference of the splat rasterizer: the oracle of tests and benches.
//
// Plain scalar C, one pixel at a time, not optimised: only correctness matters. It follows the conventions
// of golden/splat/README.md (3D Gaussian Splatting as Inria's CUDA rasterizer computes it):
//     u = fx X/Z + cx - 0.5 (pixel centres are integers), J with x/z clamped at +-1.3 W/(2 fx), 0.3 px^2 of blur,
//     front to back in order of Z (ties by index), alpha = min(0.99, o G), skipped below 1/255,
//     stop before a splat that would bring the transmittance below 1e-4.
// Include gsfixer_splat.h (declarations are enough) before this file. tests/test_reference.c compares it with the
// golden data and with finite differences.
//
//     ref_splats s = ref_splats_from(&splats);                 // parameters widened to double
//     ref_options o = ref_options_from(&desc);                 // or {0} for the defaults
//     ref_image image = ref_render(&s, &camera, &o);
//     ref_grads grads = ref_make_grads(s.count, s.sh_count);   // zeroed; ref_render_backward adds to it
//     ref_render_backward(&s, &camera, &o, &image, d_color, d_depth, d_alpha, &grads);
//     ref_destroy_grads(&grads); ref_destroy_image(&image); ref_destroy_splats(&s);
//
// It exits when out of memory, since this is test code.
#ifndef REFERENCE_SPLAT_H
#define REFERENCE_SPLAT_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define REF_ALPHA_MIN (1.0 / 255.0)
#define REF_ALPHA_MAX 0.99
#define REF_T_MIN 1e-4
#define REF_BLUR 0.3
#define REF_NEAR 0.2
#define REF_FRUSTUM 1.3
#define REF_TILE 16
#define REF_COMPENSATION_FLOOR 2.5e-5
// Decision margins are exact below this cap and reported as the cap above it (pixels far from a splat are not visited).
#define REF_MARGIN_CAP 0.0099

typedef struct ref_splats { // parameters in double; arrays are owned
    size_t count;
    int sh_count;       // K = 1, 4, 9 or 16 stored coefficients
    double* means;      // (count,3) world: origin added
    double* log_scales; // (count,3)
    double* quats;      // (count,4) raw wxyz
    double* logits;     // (count)
    double* sh;         // (count,K,3)
} ref_splats;

typedef struct ref_options { // zero = default
    int official_footprint; // blend only in the 16x16 tiles of the 3-sigma square
    int official_gradient;  // straight through the 0.99 clamp; the clamped x/z (times z) held constant
    int antialiased;        // opacity times sqrt(max(compensation_floor, det cov / det(cov + blur)))
    double compensation_floor; // of the ratio; ref_options_from: 2.5e-5, as in Inria's antialiased rasterizer
    int sh_bands;           // degree + 1; 0 = all stored
    double near_plane;      // 0 = 0.2
    double opacity_scale;   // 0 = 1
    double background[3];
    const uint8_t* hidden;  // (count) or NULL
    const double* offset2d; // (count,2) pixels added to the projected means, or NULL; for finite differences
} ref_options;

typedef struct ref_projected { // one splat on the screen; all zero but z when it is not visible
    int visible;
    double z;               // camera depth
    double u, v;            // pixels
    double cov[3], conic[3];// a b c of [[a,b],[b,c]], blur included
    double opacity;         // sigmoid times scale, without the antialiasing factor
    double compensation;    // the antialiasing factor (1 when off)
    double color[3];
    int64_t radius;         // ceil(3 sigma)
    int rect[4];            // tiles x0 y0 x1 y1 (exclusive), as getRect
    double box[4];          // pixels that can be within REF_MARGIN_CAP of alpha = 1/255: u0 v0 u1 v1
    double near_margin;     // |z / near - 1|
    double official_margin;  // smallest distance of 3 sigma and of the tile rectangle's sides (in tiles) from an
                             // integer, relative if above 1: Inria's footprint depends on these
    double kink_margin;     // distance of the colour clamp (absolute), of the x/z clamp and of the compensation's floor
                            // (relative): kinks of gradients
} ref_projected;

typedef struct ref_image { // arrays are owned
    int width, height;
    double* color;          // (H,W,3)
    double* depth;          // (H,W) sum(w z)/sum(w), 0 where nothing was blended
    double* inverse_depth;  // (H,W) sum(w/z)
    double* T;              // (H,W) final transmittance
    int32_t* blended;       // (H,W) number of blended splats
    double* margin;         // (H,W) smallest relative distance of alpha to 1/255 and 0.99, of T(1-alpha) to 1e-4
    double* depth_gap;      // (H,W) smallest relative depth difference of neighbours in the blending order; coincident
                            //       splats (their order is by index) do not count
    double* cancellation;   // (H,W) largest |terms| of a blended splat's exponent: what a float renderer multiplies its
                            //       rounding by
    size_t count, order_count;
    ref_projected* splats;  // (count)
    uint32_t* order;        // (order_count) visible splats front to back
} ref_image;

typedef struct ref_grads { // shapes as ref_splats; arrays are owned
    double *means, *log_scales, *quats, *logits, *sh;
    double* means2d;        // (count,2) per pixel
    double* means2d_abs;    // (count,2) |.| per pixel before the sum
    double background[3];
} ref_grads;

static inline void* ref_alloc(size_t count, size_t size) {
    void* memory = calloc(count ? count : 1, size);
    if (!memory) { fprintf(stderr, "reference_splat: out of memory\n"); exit(2); }
    return memory;
}

static inline ref_splats ref_make_splats(size_t count, int sh_count) {
    ref_splats s;
    s.count = count;
    s.sh_count = sh_count;
    s.means = (double*)ref_alloc(count, 3 * sizeof(double));
    s.log_scales = (double*)ref_alloc(count, 3 * sizeof(double));
    s.quats = (double*)ref_alloc(count, 4 * sizeof(double));
    s.logits = (double*)ref_alloc(count, sizeof(double));
    s.sh = (double*)ref_alloc(count, 3 * (size_t)sh_count * sizeof(double));
    return s;
}

static inline void ref_destroy_splats(ref_splats* s) {
    free(s->means); free(s->log_scales); free(s->quats); free(s->logits); free(s->sh);
    memset(s, 0, sizeof *s);
}

static inline ref_splats ref_splats_from(const gsf_splats* in) {
    const int K = (in->sh_degree + 1) * (in->sh_degree + 1);
    ref_splats s = ref_make_splats(in->count, K);
    for (size_t i = 0; i < 3 * in->count; i++) s.means[i] = in->origin[i % 3] + (double)in->means[i];
    for (size_t i = 0; i < 3 * in->count; i++) s.log_scales[i] = (double)in->log_scales[i];
    for (size_t i = 0; i < 4 * in->count; i++) s.quats[i] = (double)in->quats[i];
    for (size_t i = 0; i < in->count; i++) s.logits[i] = (double)in->opacity_logits[i];
    for (size_t i = 0; i < 3 * (size_t)K * in->count; i++) s.sh[i] = (double)in->sh[i];
    return s;
}

static inline ref_options ref_options_from(const gsf_render_desc* desc) {
    ref_options o;
    memset(&o, 0, sizeof o);
    if (!desc) return o;
    o.official_footprint = desc->footprint == GSF_FOOTPRINT_OFFICIAL;
    o.official_gradient = desc->gradient == GSF_GRADIENT_OFFICIAL;
    o.antialiased = desc->antialiased;
    o.compensation_floor = REF_COMPENSATION_FLOOR;
    o.sh_bands = desc->sh_bands;
    o.near_plane = (double)desc->near_plane;
    o.opacity_scale = (double)desc->opacity_scale;
    for (int c = 0; c < 3; c++) o.background[c] = (double)desc->background[c];
    o.hidden = desc->hidden;
    return o;
}

static inline ref_grads ref_make_grads(size_t count, int sh_count) {
    ref_grads g;
    memset(&g, 0, sizeof g);
    g.means = (double*)ref_alloc(count, 3 * sizeof(double));
    g.log_scales = (double*)ref_alloc(count, 3 * sizeof(double));
    g.quats = (double*)ref_alloc(count, 4 * sizeof(double));
    g.logits = (double*)ref_alloc(count, sizeof(double));
    g.sh = (double*)ref_alloc(count, 3 * (size_t)sh_count * sizeof(double));
    g.means2d = (double*)ref_alloc(count, 2 * sizeof(double));
    g.means2d_abs = (double*)ref_alloc(count, 2 * sizeof(double));
    return g;
}

static inline void ref_destroy_grads(ref_grads* g) {
    free(g->means); free(g->log_scales); free(g->quats); free(g->logits); free(g->sh);
    free(g->means2d); free(g->means2d_abs);
    memset(g, 0, sizeof *g);
}

// ---- small maths ---------------------------------------------------------------

static inline void ref_cross(const double a[3], const double b[3], double out[3]) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}
static inline double ref_dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Rotation of q / max(|q|, 1e-12) by the formula for unit quaternions, so that zero gives the identity.
static inline void ref_rotation(const double q[4], double unit[4], double R[3][3]) {
    const double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 4; k++) unit[k] = q[k] / fmax(norm, 1e-12);
    const double w = unit[0], x = unit[1], y = unit[2], z = unit[3];
    R[0][0] = 1 - 2 * (y * y + z * z); R[0][1] = 2 * (x * y - w * z);     R[0][2] = 2 * (x * z + w * y);
    R[1][0] = 2 * (x * y + w * z);     R[1][1] = 1 - 2 * (x * x + z * z); R[1][2] = 2 * (y * z - w * x);
    R[2][0] = 2 * (x * z - w * y);     R[2][1] = 2 * (y * z + w * x);     R[2][2] = 1 - 2 * (x * x + y * y);
}

// dR (3x3) to the raw quaternion, added to dq.
static inline void ref_rotation_backward(const double q[4], double dR[3][3], double dq[4]) {
    double unit[4], R[3][3];
    ref_rotation(q, unit, R);
    const double w = unit[0], x = unit[1], y = unit[2], z = unit[3];
    double du[4];
    du[0] = 2 * (-z * dR[0][1] + y * dR[0][2] + z * dR[1][0] - x * dR[1][2] - y * dR[2][0] + x * dR[2][1]);
    du[1] = 2 * (y * dR[0][1] + z * dR[0][2] + y * dR[1][0] - 2 * x * dR[1][1] - w * dR[1][2] + z * dR[2][0] +
                 w * dR[2][1] - 2 * x * dR[2][2]);
    du[2] = 2 * (-2 * y * dR[0][0] + x * dR[0][1] + w * dR[0][2] + x * dR[1][0] + z * dR[1][2] - w * dR[2][0] +
                 z * dR[2][1] - 2 * y * dR[2][2]);
    du[3] = 2 * (-2 * z * dR[0][0] - w * dR[0][1] + x * dR[0][2] + w * dR[1][0] - 2 * z * dR[1][1] + y * dR[1][2] +
                 x * dR[2][0] + y * dR[2][1]);
    const double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double along = norm > 1e-12 ? unit[0] * du[0] + unit[1] * du[1] + unit[2] * du[2] + unit[3] * du[3] : 0.0;
    for (int k = 0; k < 4; k++) dq[k] += (du[k] - along * unit[k]) / fmax(norm, 1e-12);
}

// Real spherical harmonics of degree < bands in the signs of 3DGS, and their derivatives by x, y, z taken as
// polynomials.
static inline void ref_sh_basis(int bands, const double d[3], double basis[16], double derivative[16][3]) {
    static const double c2[5] = {1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
                                 0.5462742152960396};
    static const double c3[7] = {-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
                                 -0.4570457994644658, 1.445305721320277, -0.5900435899266435};
    const double c0 = 0.28209479177387814, c1 = 0.4886025119029199;
    const double x = d[0], y = d[1], z = d[2], xx = x * x, yy = y * y, zz = z * z;
    memset(basis, 0, 16 * sizeof(double));
    memset(derivative, 0, 16 * sizeof derivative[0]);
#define REF_SH(k, value, dx, dy, dz) \
    basis[k] = (value); derivative[k][0] = (dx); derivative[k][1] = (dy); derivative[k][2] = (dz)
    REF_SH(0, c0, 0, 0, 0);
    if (bands < 2) return;
    REF_SH(1, -c1 * y, 0, -c1, 0);
    REF_SH(2, c1 * z, 0, 0, c1);
    REF_SH(3, -c1 * x, -c1, 0, 0);
    if (bands < 3) return;
    REF_SH(4, c2[0] * x * y, c2[0] * y, c2[0] * x, 0);
    REF_SH(5, c2[1] * y * z, 0, c2[1] * z, c2[1] * y);
    REF_SH(6, c2[2] * (2 * zz - xx - yy), -2 * c2[2] * x, -2 * c2[2] * y, 4 * c2[2] * z);
    REF_SH(7, c2[3] * x * z, c2[3] * z, 0, c2[3] * x);
    REF_SH(8, c2[4] * (xx - yy), 2 * c2[4] * x, -2 * c2[4] * y, 0);
    if (bands < 4) return;
    REF_SH(9, c3[0] * y * (3 * xx - yy), 6 * c3[0] * x * y, 3 * c3[0] * (xx - yy), 0);
    REF_SH(10, c3[1] * x * y * z, c3[1] * y * z, c3[1] * x * z, c3[1] * x * y);
    REF_SH(11, c3[2] * y * (4 * zz - xx - yy), -2 * c3[2] * x * y, c3[2] * (4 * zz - xx - 3 * yy), 8 * c3[2] * y * z);
    REF_SH(12, c3[3] * z * (2 * zz - 3 * xx - 3 * yy), -6 * c3[3] * x * z, -6 * c3[3] * y * z,
           c3[3] * (6 * zz - 3 * xx - 3 * yy));
    REF_SH(13, c3[4] * x * (4 * zz - xx - yy), c3[4] * (4 * zz - 3 * xx - yy), -2 * c3[4] * x * y, 8 * c3[4] * x * z);
    REF_SH(14, c3[5] * z * (xx - yy), 2 * c3[5] * x * z, -2 * c3[5] * y * z, c3[5] * (xx - yy));
    REF_SH(15, c3[6] * x * (xx - 3 * yy), 3 * c3[6] * (xx - yy), -6 * c3[6] * x * y, 0);
#undef REF_SH
}

// ---- projection ----------------------------------------------------------------

typedef struct ref_geometry { // what projection and its backward share
    double p[3];        // camera coordinates of the mean
    double W[3][3];     // rotation of w2c
    double R[3][3];     // rotation of the splat
    double scale[3];
    double ratio[2];    // x/z and y/z, clamped
    int clamped[2];
    double J[2][3];
    double TW[2][3];    // J W
    double V[2][3];     // J W R S: the covariance without blur is V V^T
    double minors[3];   // row 0 x row 1 of V; their squares sum to its determinant
    double det, det_blurred;
    double direction[3], distance; // from the camera centre
    double basis[16], basis_derivative[16][3];
    double raw_color[3];
    int bands;
} ref_geometry;

static inline ref_geometry ref_geometry_of(const ref_splats* s, const gsf_camera* camera, const ref_options* o,
                                           size_t i) {
    ref_geometry g;
    memset(&g, 0, sizeof g);
    const double* m = camera->w2c;
    const double* mean = s->means + 3 * i;
    double center[3];
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) g.W[r][c] = m[4 * c + r];
    for (int r = 0; r < 3; r++) g.p[r] = ref_dot(g.W[r], mean) + m[12 + r];
    for (int c = 0; c < 3; c++) center[c] = -(g.W[0][c] * m[12] + g.W[1][c] * m[13] + g.W[2][c] * m[14]);

    const double z = g.p[2], focal[2] = {camera->fx, camera->fy}, size[2] = {camera->width, camera->height};
    for (int a = 0; a < 2; a++) {
        const double limit = REF_FRUSTUM * size[a] / (2 * focal[a]);
        g.ratio[a] = g.p[a] / z;
        g.clamped[a] = fabs(g.ratio[a]) > limit;
        g.ratio[a] = fmin(fmax(g.ratio[a], -limit), limit);
        g.J[a][a] = focal[a] / z;
        g.J[a][2] = -focal[a] * g.ratio[a] / z;
    }
    double unit[4];
    ref_rotation(s->quats + 4 * i, unit, g.R);
    for (int k = 0; k < 3; k++) g.scale[k] = exp(s->log_scales[3 * i + k]);
    for (int a = 0; a < 2; a++)
        for (int k = 0; k < 3; k++)
            g.TW[a][k] = g.J[a][0] * g.W[0][k] + g.J[a][1] * g.W[1][k] + g.J[a][2] * g.W[2][k];
    for (int a = 0; a < 2; a++)
        for (int k = 0; k < 3; k++)
            g.V[a][k] = (g.TW[a][0] * g.R[0][k] + g.TW[a][1] * g.R[1][k] + g.TW[a][2] * g.R[2][k]) * g.scale[k];
    ref_cross(g.V[0], g.V[1], g.minors);
    g.det = ref_dot(g.minors, g.minors); // Cauchy-Binet: no cancellation, however thin the splat
    g.det_blurred = g.det + REF_BLUR * (ref_dot(g.V[0], g.V[0]) + ref_dot(g.V[1], g.V[1])) + REF_BLUR * REF_BLUR;

    for (int c = 0; c < 3; c++) g.direction[c] = mean[c] - center[c];
    g.distance = sqrt(ref_dot(g.direction, g.direction));
    for (int c = 0; c < 3; c++) g.direction[c] /= g.distance;
    int stored = 1;
    while (stored * stored < s->sh_count) stored++;
    g.bands = o->sh_bands > 0 && o->sh_bands < stored ? o->sh_bands : stored;
    ref_sh_basis(g.bands, g.direction, g.basis, g.basis_derivative);
    for (int c = 0; c < 3; c++) {
        g.raw_color[c] = 0.5;
        for (int k = 0; k < g.bands * g.bands; k++)
            g.raw_color[c] += g.basis[k] * s->sh[((size_t)s->sh_count * i + (size_t)k) * 3 + (size_t)c];
    }
    return g;
}

// (int) of a quotient by 16, clamped to the grid, as in getRect but safe for any size.
static inline int ref_tile(double pixels, int grid) {
    return (int)fmin(fmax(trunc(pixels / REF_TILE), 0.0), (double)grid);
}

static inline int ref_is_finite(const ref_splats* s, size_t i) {
    double sum = s->logits[i] * 0;
    for (int k = 0; k < 3; k++) sum += (s->means[3 * i + k] + s->log_scales[3 * i + k]) * 0;
    for (int k = 0; k < 4; k++) sum += s->quats[4 * i + k] * 0;
    for (int k = 0; k < 3 * s->sh_count; k++) sum += s->sh[3 * (size_t)s->sh_count * i + k] * 0;
    return sum == 0;
}

static inline ref_projected ref_project(const ref_splats* s, const gsf_camera* camera, const ref_options* o, size_t i) {
    ref_projected p;
    memset(&p, 0, sizeof p);
    p.near_margin = p.kink_margin = p.official_margin = INFINITY;
    if (!ref_is_finite(s, i)) return p;
    const ref_geometry g = ref_geometry_of(s, camera, o, i);
    const double near_plane = o->near_plane > 0 ? o->near_plane : REF_NEAR;
    p.z = g.p[2];
    p.near_margin = fabs(p.z / near_plane - 1);
    if (p.z <= near_plane || (o->hidden && o->hidden[i])) return p;

    p.u = camera->fx * g.p[0] / p.z + camera->cx - 0.5 + (o->offset2d ? o->offset2d[2 * i] : 0);
    p.v = camera->fy * g.p[1] / p.z + camera->cy - 0.5 + (o->offset2d ? o->offset2d[2 * i + 1] : 0);
    p.cov[0] = ref_dot(g.V[0], g.V[0]) + REF_BLUR;
    p.cov[1] = ref_dot(g.V[0], g.V[1]);
    p.cov[2] = ref_dot(g.V[1], g.V[1]) + REF_BLUR;
    p.conic[0] = p.cov[2] / g.det_blurred;
    p.conic[1] = -p.cov[1] / g.det_blurred;
    p.conic[2] = p.cov[0] / g.det_blurred;
    p.opacity = (o->opacity_scale > 0 ? o->opacity_scale : 1) / (1 + exp(-s->logits[i]));
    p.compensation = o->antialiased ? sqrt(fmax(o->compensation_floor, g.det / g.det_blurred)) : 1;
    for (int c = 0; c < 3; c++) p.color[c] = fmax(g.raw_color[c], 0);

    const double mid = 0.5 * (p.cov[0] + p.cov[2]);
    const double sigma3 = 3 * sqrt(mid + sqrt(fmax(0.1, mid * mid - g.det_blurred))), radius = ceil(sigma3);
    p.radius = (int64_t)fmin(radius, 9e18);
    const int grid_x = (camera->width + REF_TILE - 1) / REF_TILE, grid_y = (camera->height + REF_TILE - 1) / REF_TILE;
    const double sides[4] = {p.u - radius, p.v - radius, p.u + radius + REF_TILE - 1, p.v + radius + REF_TILE - 1};
    p.official_margin = fabs(sigma3 - round(sigma3)) / fmax(1, sigma3);
    for (int k = 0; k < 4; k++) {
        const double tiles = sides[k] / REF_TILE;
        p.rect[k] = ref_tile(sides[k], k % 2 ? grid_y : grid_x);
        if (tiles > -1 && tiles < (k % 2 ? grid_y : grid_x) + 1)
            p.official_margin = fmin(p.official_margin, fabs(tiles - round(tiles)));
    }
    p.visible = 1;
    if (o->official_footprint && (p.rect[0] >= p.rect[2] || p.rect[1] >= p.rect[3])) {
        const double z = p.z, near_margin = p.near_margin, official_margin = p.official_margin;
        memset(&p, 0, sizeof p);
        p.z = z;
        p.near_margin = near_margin;
        p.kink_margin = INFINITY;
        p.official_margin = official_margin;
        return p;
    }

    // o G >= (1 - cap)/255 inside the ellipse d^T cov^-1 d <= t, whose box has half sides sqrt(t cov_xx), sqrt(t
    // cov_yy).
    const double t = 2 * log(255 * p.opacity * p.compensation / (1 - REF_MARGIN_CAP));
    const double half_x = t > 0 ? sqrt(t * p.cov[0]) : -1, half_y = t > 0 ? sqrt(t * p.cov[2]) : -1;
    p.box[0] = p.u - half_x; p.box[1] = p.v - half_y; p.box[2] = p.u + half_x; p.box[3] = p.v + half_y;

    for (int c = 0; c < 3; c++) p.kink_margin = fmin(p.kink_margin, fabs(g.raw_color[c]));
    if (o->antialiased && o->compensation_floor > 0)
        p.kink_margin = fmin(p.kink_margin, fabs(g.det / g.det_blurred / o->compensation_floor - 1));
    const double limit[2] = {REF_FRUSTUM * camera->width / (2 * camera->fx),
                             REF_FRUSTUM * camera->height / (2 * camera->fy)};
    for (int a = 0; a < 2; a++) p.kink_margin = fmin(p.kink_margin, fabs(fabs(g.p[a] / g.p[2]) / limit[a] - 1));
    return p;
}

// Gradients of one splat: from the screen (mean2d, conic as a b c, opacity with compensation, colour, depth) back to
// the parameters.
typedef struct ref_screen_grads { double mean2d[2], conic[3], opacity, color[3], z; } ref_screen_grads;

static inline void ref_project_backward(const ref_splats* s, const gsf_camera* camera, const ref_options* o, size_t i,
                                        const ref_projected* p, const ref_screen_grads* d, ref_grads* out) {
    const ref_geometry g = ref_geometry_of(s, camera, o, i);
    const double z = g.p[2];
    double dp[3] = {0, 0, d->z}; // camera coordinates

    // opacity_on_screen = scale sigmoid(logit) compensation
    const double sigmoid = 1 / (1 + exp(-s->logits[i]));
    const double scale = o->opacity_scale > 0 ? o->opacity_scale : 1;
    out->logits[i] += d->opacity * p->compensation * scale * sigmoid / (1 + exp(s->logits[i]));
    const int floored = g.det / g.det_blurred < o->compensation_floor;
    const double d_compensation = o->antialiased && !floored ? d->opacity * p->opacity : 0;

    // conic = cov^-1: d_cov = -conic d_conic conic, all symmetric 2x2
    const double K[2][2] = {{p->conic[0], p->conic[1]}, {p->conic[1], p->conic[2]}};
    const double dK[2][2] = {{d->conic[0], 0.5 * d->conic[1]}, {0.5 * d->conic[1], d->conic[2]}};
    double dcov[2][2] = {{0, 0}, {0, 0}};
    for (int a = 0; a < 2; a++)
        for (int b = 0; b < 2; b++) {
            for (int k = 0; k < 2; k++)
                for (int l = 0; l < 2; l++) dcov[a][b] -= K[a][k] * dK[k][l] * K[l][b];
            // compensation = sqrt(det / det_blurred); d log det_blurred / d cov = cov^-1
            dcov[a][b] -= 0.5 * d_compensation * p->compensation * K[a][b];
        }
    // cov = V V^T + blur
    double dV[2][3];
    for (int a = 0; a < 2; a++)
        for (int k = 0; k < 3; k++) dV[a][k] = 2 * (dcov[a][0] * g.V[0][k] + dcov[a][1] * g.V[1][k]);
    // sqrt(det) = |minors|, minors = V[0] x V[1]
    if (g.det > 0 && d_compensation != 0) {
        double n[3], toward0[3], toward1[3];
        for (int k = 0; k < 3; k++) n[k] = g.minors[k] / sqrt(g.det);
        ref_cross(g.V[1], n, toward0);
        ref_cross(n, g.V[0], toward1);
        for (int k = 0; k < 3; k++) dV[0][k] += d_compensation / sqrt(g.det_blurred) * toward0[k];
        for (int k = 0; k < 3; k++) dV[1][k] += d_compensation / sqrt(g.det_blurred) * toward1[k];
    }
    // V = TW R S
    double dR[3][3], dTW[2][3] = {{0, 0, 0}, {0, 0, 0}};
    for (int k = 0; k < 3; k++) {
        double along = 0;
        for (int r = 0; r < 3; r++) {
            const double dM = g.TW[0][r] * dV[0][k] + g.TW[1][r] * dV[1][k]; // M = R S
            along += dM * g.R[r][k];
            dR[r][k] = dM * g.scale[k];
            for (int a = 0; a < 2; a++) dTW[a][r] += dV[a][k] * g.R[r][k] * g.scale[k];
        }
        out->log_scales[3 * i + k] += along * g.scale[k];
    }
    ref_rotation_backward(s->quats + 4 * i, dR, out->quats + 4 * i);
    // TW = J W, J[a][a] = f / z, J[a][2] = -f ratio / z
    const double focal[2] = {camera->fx, camera->fy};
    for (int a = 0; a < 2; a++) {
        const double dJa = ref_dot(dTW[a], g.W[a]), dJ2 = ref_dot(dTW[a], g.W[2]), r = g.ratio[a], f = focal[a];
        dp[2] -= dJa * f / (z * z);
        if (!g.clamped[a]) { // ratio = p[a] / z
            dp[a] -= dJ2 * f / (z * z);
            dp[2] += 2 * dJ2 * f * r / (z * z);
        } else {             // ratio constant; Inria: ratio times z constant
            dp[2] += (o->official_gradient ? 2 : 1) * dJ2 * f * r / (z * z);
        }
        // u = f p[a] / z + c
        dp[a] += d->mean2d[a] * f / z;
        dp[2] -= d->mean2d[a] * f * g.p[a] / (z * z);
        out->means2d[2 * i + a] += d->mean2d[a];
    }
    // colour = max(0, sum basis(direction) sh + 0.5), direction = (mean - centre) / distance
    double d_direction[3] = {0, 0, 0};
    for (int c = 0; c < 3; c++) {
        if (g.raw_color[c] < 0) continue;
        for (int k = 0; k < g.bands * g.bands; k++) {
            const size_t at = ((size_t)s->sh_count * i + (size_t)k) * 3 + (size_t)c;
            out->sh[at] += d->color[c] * g.basis[k];
            for (int a = 0; a < 3; a++) d_direction[a] += d->color[c] * s->sh[at] * g.basis_derivative[k][a];
        }
    }
    const double radial = ref_dot(d_direction, g.direction);
    for (int a = 0; a < 3; a++)
        out->means[3 * i + a] += g.W[0][a] * dp[0] + g.W[1][a] * dp[1] + g.W[2][a] * dp[2] +
                                 (d_direction[a] - radial * g.direction[a]) / g.distance;
}

// ---- pixels --------------------------------------------------------------------

typedef struct ref_hit { // one blended splat of a pixel
    uint32_t splat;
    double dx, dy;    // projected mean - pixel
    double gauss;     // exp(power)
    double alpha;     // min(0.99, opacity gauss)
    int saturated;    // clamped to 0.99
    double T;         // transmittance in front of it
} ref_hit;

typedef struct ref_decisions { double margin, depth_gap, cancellation; } ref_decisions;

// Splats blended in pixel (x, y), front to back; returns their number. hits: room for order_count. T_final: the
// transmittance behind the last one.
static inline size_t ref_trace(const ref_image* image, const ref_splats* s, const ref_options* o, int x, int y,
                               ref_hit* hits, double* T_final, ref_decisions* decisions) {
    size_t n = 0;
    double T = 1;
    const ref_projected* previous = NULL;
    size_t previous_index = 0;
    decisions->margin = REF_MARGIN_CAP;
    decisions->depth_gap = INFINITY;
    decisions->cancellation = 0;
    for (size_t k = 0; k < image->order_count; k++) {
        const uint32_t i = image->order[k];
        const ref_projected* p = &image->splats[i];
        if (x < p->box[0] || x > p->box[2] || y < p->box[1] || y > p->box[3]) continue;
        if (o->official_footprint && (x / REF_TILE < p->rect[0] || x / REF_TILE >= p->rect[2] ||
                                      y / REF_TILE < p->rect[1] || y / REF_TILE >= p->rect[3])) continue;
        const double dx = p->u - x, dy = p->v - y;
        const double power = -0.5 * (p->conic[0] * dx * dx + p->conic[2] * dy * dy) - p->conic[1] * dx * dy;
        if (power > 0) continue;
        const double gauss = exp(power), raw = p->opacity * p->compensation * gauss;
        decisions->margin = fmin(decisions->margin, fabs(raw / REF_ALPHA_MIN - 1));
        if (raw < REF_ALPHA_MIN) continue;
        decisions->margin = fmin(decisions->margin, fabs(raw / REF_ALPHA_MAX - 1));
        const double terms = 0.5 * (p->conic[0] * dx * dx + p->conic[2] * dy * dy) + fabs(p->conic[1] * dx * dy);
        decisions->cancellation = fmax(decisions->cancellation, terms);
        if (previous) {
            const double* a = s->means + 3 * previous_index;
            const double* b = s->means + 3 * (size_t)i;
            if (a[0] != b[0] || a[1] != b[1] || a[2] != b[2])
                decisions->depth_gap = fmin(decisions->depth_gap, (p->z - previous->z) / p->z);
        }
        previous = p;
        previous_index = i;
        const double alpha = fmin(raw, REF_ALPHA_MAX);
        decisions->margin = fmin(decisions->margin, fabs(T * (1 - alpha) / REF_T_MIN - 1));
        if (T * (1 - alpha) < REF_T_MIN) break;
        hits[n].splat = i;
        hits[n].dx = dx;
        hits[n].dy = dy;
        hits[n].gauss = gauss;
        hits[n].alpha = alpha;
        hits[n].saturated = raw > REF_ALPHA_MAX;
        hits[n].T = T;
        n++;
        T *= 1 - alpha;
    }
    *T_final = T;
    return n;
}

typedef struct ref_depth_key { double z; uint32_t index; } ref_depth_key;

static inline int ref_compare_depth(const void* pa, const void* pb) {
    const ref_depth_key *a = (const ref_depth_key*)pa, *b = (const ref_depth_key*)pb;
    if (a->z != b->z) return a->z < b->z ? -1 : 1;
    return a->index < b->index ? -1 : a->index > b->index;
}

static inline ref_image ref_render(const ref_splats* s, const gsf_camera* camera, const ref_options* o) {
    ref_image image;
    memset(&image, 0, sizeof image);
    image.width = camera->width;
    image.height = camera->height;
    const size_t pixels = (size_t)camera->width * (size_t)camera->height;
    image.color = (double*)ref_alloc(pixels, 3 * sizeof(double));
    image.depth = (double*)ref_alloc(pixels, sizeof(double));
    image.inverse_depth = (double*)ref_alloc(pixels, sizeof(double));
    image.T = (double*)ref_alloc(pixels, sizeof(double));
    image.blended = (int32_t*)ref_alloc(pixels, sizeof(int32_t));
    image.margin = (double*)ref_alloc(pixels, sizeof(double));
    image.depth_gap = (double*)ref_alloc(pixels, sizeof(double));
    image.cancellation = (double*)ref_alloc(pixels, sizeof(double));
    image.count = s->count;
    image.splats = (ref_projected*)ref_alloc(s->count, sizeof(ref_projected));
    image.order = (uint32_t*)ref_alloc(s->count, sizeof(uint32_t));

    ref_depth_key* keys = (ref_depth_key*)ref_alloc(s->count, sizeof(ref_depth_key));
    for (size_t i = 0; i < s->count; i++) {
        image.splats[i] = ref_project(s, camera, o, i);
        if (!image.splats[i].visible) continue;
        keys[image.order_count].z = image.splats[i].z;
        keys[image.order_count++].index = (uint32_t)i;
    }
    qsort(keys, image.order_count, sizeof keys[0], ref_compare_depth);
    for (size_t k = 0; k < image.order_count; k++) image.order[k] = keys[k].index;
    free(keys);

    ref_hit* hits = (ref_hit*)ref_alloc(image.order_count, sizeof(ref_hit));
    for (size_t at = 0; at < pixels; at++) {
        ref_decisions decisions;
        double T, weight = 0, weighted_z = 0, color[3] = {0, 0, 0};
        const size_t n = ref_trace(&image, s, o, (int)(at % (size_t)image.width), (int)(at / (size_t)image.width), hits,
                                   &T, &decisions);
        for (size_t k = 0; k < n; k++) {
            const ref_projected* p = &image.splats[hits[k].splat];
            const double w = hits[k].alpha * hits[k].T;
            for (int c = 0; c < 3; c++) color[c] += w * p->color[c];
            weight += w;
            weighted_z += w * p->z;
            image.inverse_depth[at] += w / p->z;
        }
        for (int c = 0; c < 3; c++) image.color[3 * at + c] = color[c] + T * o->background[c];
        image.depth[at] = n ? weighted_z / weight : 0;
        image.T[at] = T;
        image.blended[at] = (int32_t)n;
        image.margin[at] = decisions.margin;
        image.depth_gap[at] = decisions.depth_gap;
        image.cancellation[at] = decisions.cancellation;
    }
    free(hits);
    return image;
}

static inline void ref_destroy_image(ref_image* image) {
    free(image->color); free(image->depth); free(image->inverse_depth); free(image->T); free(image->blended);
    free(image->margin); free(image->depth_gap); free(image->cancellation); free(image->splats); free(image->order);
    memset(image, 0, sizeof *image);
}

// Derivatives of a loss with respect to colour (H,W,3), expected depth (H,W) and alpha = 1 - T (H,W) to all parameters.
// `image` is the result of ref_render for the same arguments. A NULL derivative means zero. Adds to *out.
static inline void ref_render_backward(const ref_splats* s, const gsf_camera* camera, const ref_options* o,
                                       const ref_image* image, const double* d_color, const double* d_depth,
                                       const double* d_alpha, ref_grads* out) {
    const size_t pixels = (size_t)image->width * (size_t)image->height;
    ref_screen_grads* screen = (ref_screen_grads*)ref_alloc(s->count, sizeof(ref_screen_grads));
    ref_hit* hits = (ref_hit*)ref_alloc(image->order_count, sizeof(ref_hit));
    for (size_t at = 0; at < pixels; at++) {
        ref_decisions decisions;
        double T;
        const size_t n = ref_trace(image, s, o, (int)(at % (size_t)image->width), (int)(at / (size_t)image->width),
                                   hits, &T, &decisions);
        double dc[3];
        for (int c = 0; c < 3; c++) dc[c] = d_color ? d_color[3 * at + c] : 0;
        for (int c = 0; c < 3; c++) out->background[c] += T * dc[c];
        if (n == 0) continue;
        // alpha = A and depth = Z / A, where A = sum w and Z = sum w z
        const double A = 1 - T;
        const double dZ = d_depth ? d_depth[at] / A : 0;
        const double dA = (d_alpha ? d_alpha[at] : 0) - (d_depth ? d_depth[at] * image->depth[at] / A : 0);
        // f_k: the loss' derivative with respect to the weight of splat k; behind: the sum of w f over everything
        // behind it.
        double behind = T * (dc[0] * o->background[0] + dc[1] * o->background[1] + dc[2] * o->background[2]);
        for (size_t k = n; k-- > 0;) {
            const ref_hit* h = &hits[k];
            const ref_projected* p = &image->splats[h->splat];
            ref_screen_grads* d = &screen[h->splat];
            const double w = h->alpha * h->T, f = ref_dot(dc, p->color) + dZ * p->z + dA;
            for (int c = 0; c < 3; c++) d->color[c] += w * dc[c];
            d->z += w * dZ;
            // w_k = alpha_k T_k, and every weight behind it has a factor 1 - alpha_k
            const double d_alpha_k = h->T * f - behind / (1 - h->alpha);
            behind += w * f;
            if (h->saturated && !o->official_gradient) continue;
            d->opacity += d_alpha_k * h->gauss;
            const double d_power = d_alpha_k * p->opacity * p->compensation * h->gauss;
            const double dx = h->dx, dy = h->dy;
            d->conic[0] -= 0.5 * d_power * dx * dx;
            d->conic[1] -= d_power * dx * dy;
            d->conic[2] -= 0.5 * d_power * dy * dy;
            const double du = -d_power * (p->conic[0] * dx + p->conic[1] * dy);
            const double dv = -d_power * (p->conic[1] * dx + p->conic[2] * dy);
            d->mean2d[0] += du;
            d->mean2d[1] += dv;
            out->means2d_abs[2 * (size_t)h->splat] += fabs(du);
            out->means2d_abs[2 * (size_t)h->splat + 1] += fabs(dv);
        }
    }
    free(hits);
    for (size_t k = 0; k < image->order_count; k++) {
        const uint32_t i = image->order[k];
        ref_project_backward(s, camera, o, i, &image->splats[i], &screen[i], out);
    }
    free(screen);
}

#endif
