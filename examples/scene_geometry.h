// scene_geometry.h - the mesh of a scene and the shapes it is built from. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_GEOMETRY_H
#define SCENE_GEOMETRY_H

#include "gsfixer_splat.h"
#include "scene_materials.h"
#include "scene_trace.h"

typedef struct make_scene_options {
    int views, width, height, points;
    double noise, arc;
    uint64_t seed;
    double drift;
    int layout; // index of layouts[], 0: the courtyard
} make_scene_options;

static const make_scene_options make_scene_defaults = {40, 320, 240, 10000, 0.5, 150.0, 1, 0.0, 0};

typedef struct vertex { v3 at, normal, local, light; } vertex; // light: diffuse light from sky and surroundings
typedef struct triangle { uint32_t v[3]; } triangle;

typedef struct patch { size_t first; int nu, nw; } patch;            // of the mesh: (nu + 1) x (nw + 1) vertices

// A ball of light. Surfaces at distance d receive color / d^2, shadows begin outside of the radius.
typedef struct lamp { v3 at, color; float radius; } lamp;

typedef struct air {
    v3 sun_direction, sun_color, horizon, zenith, haze; // no sun: black
    float haze_density;                                 // per metre
    v3 fill; // light that surfaces seen in a reflection get in place of the sun and the lamps
} air;

enum { ORBIT, FORWARD, WALK };

typedef struct capture {
    int kind;
    float focal;            // focal length / width
    v3 aim;                 // ORBIT: the middle; FORWARD: looked at; WALK: end of the way
    v3 from;                // FORWARD: middle of the camera positions; WALK: start of the way
    float distance, height; // ORBIT
    float start;            // radians; ORBIT: direction of the middle photo's camera; WALK: where it looks, from ahead
    float spread;           // FORWARD: half the width of the camera positions; WALK: sway
    float turn;             // WALK: how far the camera turns to both sides, radians
} capture;

typedef struct world {
    vertex* vertices;
    triangle* triangles;
    surface* surfaces; // per triangle
    patch* patches;
    size_t vertex_count, vertex_room, triangle_count, triangle_room, surface_room, patch_count, patch_room;
    tracer rays;
    uint64_t seed, draws;
    air air;
    lamp lamps[4];
    int lamp_count;
    capture capture;
    int layout;
    float exposure;
    float pixel_angle; // of the photos, radians
    int failed;        // out of memory
} world;

typedef struct place { v3 at; float yaw; } place;
typedef v3 (*patch_fn)(float u, float w, const float* shape); // u, w in [0,1] -> local position

static void* grown(void* array, size_t* room, size_t needed, size_t size, int* failed) {
    if (needed <= *room) return array;
    *room = 2 * needed + 1024;
    void* fresh = realloc(array, *room * size);
    if (!fresh) *failed = 1;
    return fresh ? fresh : array;
}

// Adds a patch as a grid of nu x nw cells. Normals are finite differences and point along d/du x d/dw. (The courtyard
// keeps the normals it always had at the poles of spheres, and with them its photos.)
static void add_patch(world* s, patch_fn fn, const float* shape, int nu, int nw, material m, uint32_t seed,
                      place where) {
    const size_t first = s->vertex_count, points = (size_t)(nu + 1) * (size_t)(nw + 1);
    s->vertices = (vertex*)grown(s->vertices, &s->vertex_room, first + points, sizeof(vertex), &s->failed);
    const size_t cells = s->triangle_count + 2 * (size_t)nu * (size_t)nw;
    s->triangles = (triangle*)grown(s->triangles, &s->triangle_room, cells, sizeof(triangle), &s->failed);
    s->surfaces = (surface*)grown(s->surfaces, &s->surface_room, cells, sizeof(surface), &s->failed);
    s->patches = (patch*)grown(s->patches, &s->patch_room, s->patch_count + 1, sizeof(patch), &s->failed);
    if (s->failed) return;
    const patch grid = {first, nu, nw};
    s->patches[s->patch_count++] = grid;
    for (int j = 0; j <= nw; j++)
        for (int i = 0; i <= nu; i++) {
            const float u = (float)i / (float)nu, w = (float)j / (float)nw, e = 1e-3f;
            const float u0 = maxf(u - e, 0), u1 = minf(u + e, 1), w0 = maxf(w - e, 0), w1 = minf(w + e, 1);
            vertex* out = s->vertices + s->vertex_count++;
            out->local = fn(u, w, shape);
            v3 n = cross(sub(fn(u1, w, shape), fn(u0, w, shape)), sub(fn(u, w1, shape), fn(u, w0, shape)));
            if (dot(n, n) < 1e-16f && s->layout != 0) { // at a pole the normal of its surroundings
                const float near = clampf(w, 0.02f, 0.98f);
                n = cross(sub(fn(u1, near, shape), fn(u0, near, shape)),
                          sub(fn(u, near + e, shape), fn(u, near - e, shape)));
            }
            if (dot(n, n) < 1e-16f) n = cross(sub(fn(u1, 0.5f, shape), fn(u0, 0.5f, shape)), v(0, 0, 1)); // pole
            if (dot(n, n) < 1e-16f) n = v(0, 0, w < 0.5f ? -1.0f : 1.0f);
            out->normal = rotate_z(unit(n), where.yaw);
            out->at = add(rotate_z(out->local, where.yaw), where.at);
            out->light = v(0, 0, 0);
        }
    for (int j = 0; j < nw; j++)
        for (int i = 0; i < nu; i++) {
            const uint32_t a = (uint32_t)(first + (size_t)j * (size_t)(nu + 1) + (size_t)i), b = a + (uint32_t)nu + 1;
            const triangle t0 = {{a, a + 1, b}}, t1 = {{a + 1, b + 1, b}};
            const surface kind = {m, seed, where.yaw, 1.0f};
            s->surfaces[s->triangle_count] = s->surfaces[s->triangle_count + 1] = kind;
            s->triangles[s->triangle_count++] = t0;
            s->triangles[s->triangle_count++] = t1;
        }
}

static v3 patch_ground(float u, float w, const float* shape) { // denser in the middle
    (void)shape;
    const float a = 2 * u - 1, b = 2 * w - 1;
    const v3 p = v(5.2f * (0.45f * a + 0.55f * a * a * a), 5.2f * (0.45f * b + 0.55f * b * b * b), 0);
    return v(p.x, p.y, 0.05f * (fbm(mul(p, 0.9f), 3, 0) - 0.5f));
}
static v3 patch_rectangle(float u, float w, const float* s) { // corner, edge, edge
    return v(s[0] + u * s[3] + w * s[6], s[1] + u * s[4] + w * s[7], s[2] + u * s[5] + w * s[8]);
}
static v3 patch_cloth(float u, float w, const float* s) { // hangs over the ends of a table of length s[0]
    const float x = (2 * u - 1) * (0.5f * s[0] + 0.16f), over = maxf(fabsf(x) - 0.5f * s[0] - 0.006f, 0.0f);
    const float y = (w - 0.5f) * 0.5f;
    const float wave = 0.012f * sinf(23.0f * y) * minf(over * 10.0f, 1.0f);
    return v((x < 0 ? -1.0f : 1.0f) * (fabsf(x) - over + minf(over, 0.01f) + wave), y,
             0.004f - maxf(over - 0.01f, 0.0f));
}
static v3 patch_sphere(float u, float w, const float* s) { // radius, squash, lumps, seed
    const float a = 6.2831853f * u, b = 3.1415927f * (w - 0.5f);
    const v3 d = v(cosf(a) * cosf(b), sinf(a) * cosf(b), sinf(b));
    const float r = s[0] * (1.0f + s[2] * (fbm(add(mul(d, 1.6f), v(s[3], 0, 0)), 4, 0) - 0.5f));
    return v(d.x * r, d.y * r, d.z * r * s[1]);
}
static v3 patch_apple(float u, float w, const float* s) {
    const float a = 6.2831853f * u, b = 3.1415927f * w;
    const float r = s[0] * (0.62f + 0.42f * sinf(b)),
                z = -s[0] * cosf(b) * (0.72f + 0.2f * sinf(b)) * (1.0f - 0.35f * expf(-9.0f * (3.1415927f - b)));
    return v(cosf(a) * r * sinf(b), sinf(a) * r * sinf(b), z);
}
static v3 patch_torus(float u, float w, const float* s) {
    const float a = 6.2831853f * u, b = 6.2831853f * w, r = s[1] * (1.0f + 0.08f * sinf(26.0f * a + 3.0f * b));
    return v(cosf(a) * (s[0] + r * cosf(b)), sinf(a) * (s[0] + r * cosf(b)), r * sinf(b));
}
static v3 patch_lathe(float u, float w, const float* s) { // a smooth profile through s[0] pairs of (radius, height)
    const int n = (int)s[0];
    const float t = w * (float)(n - 1);
    const int i = t >= (float)(n - 1) ? n - 2 : (int)t;
    const float f = t - (float)i;
    float value[2];
    for (int k = 0; k < 2; k++) { // Catmull-Rom
        const float* q = s + 1 + k;
        const float a = q[2 * (i > 0 ? i - 1 : 0)], b = q[2 * i], c = q[2 * i + 2],
                    d = q[2 * (i + 2 < n ? i + 2 : n - 1)];
        value[k] = b + 0.5f * f * (c - a + f * (2 * a - 5 * b + 4 * c - d + f * (3 * (b - c) + d - a)));
    }
    return v(cosf(6.2831853f * u) * value[0], sinf(6.2831853f * u) * value[0], value[1]);
}
static v3 patch_leaf(float u, float w, const float* s) { // base, direction*length, side*width, curl
    const float width = sinf(3.1415927f * clampf(0.06f + 0.94f * u, 0, 1)) * (2 * w - 1),
                curl = s[9] * u * u - 0.25f * width * width * s[9];
    return v(s[0] + u * s[3] + width * s[6], s[1] + u * s[4] + width * s[7], s[2] + u * s[5] + width * s[8] - curl);
}

static void add_box(world* s, v3 lo, v3 hi, int cells, material m, uint32_t seed, place where) {
    const v3 d = sub(hi, lo);
    const float faces[6][9] = {{lo.x, lo.y, hi.z, d.x, 0, 0, 0, d.y, 0}, {lo.x, lo.y, lo.z, 0, d.y, 0, d.x, 0, 0},
                               {lo.x, lo.y, lo.z, d.x, 0, 0, 0, 0, d.z}, {lo.x, hi.y, lo.z, 0, 0, d.z, d.x, 0, 0},
                               {lo.x, lo.y, lo.z, 0, 0, d.z, 0, d.y, 0}, {hi.x, lo.y, lo.z, 0, d.y, 0, 0, 0, d.z}};
    for (int f = 0; f < 6; f++) add_patch(s, patch_rectangle, faces[f], cells, cells, m, seed, where);
}

static float pick(world* s, uint64_t stream, uint64_t index, float lo, float hi) {
    return lo + (hi - lo) * (float)gsf_draw_uniform(s->seed, stream, index);
}

static void add_bush(world* s, place where, float radius, float height, int leaves, uint64_t stream) {
    for (int i = 0; i < leaves; i++) {
        const uint64_t k = 8 * (uint64_t)i;
        const float a = pick(s, stream, k, 0, 6.2831853f), e = asinf(pick(s, stream, k + 1, -0.25f, 1.0f));
        const v3 out = v(cosf(a) * cosf(e), sinf(a) * cosf(e), sinf(e));
        const float r = sqrtf(pick(s, stream, k + 2, 0.25f, 1.0f)), length = pick(s, stream, k + 3, 0.09f, 0.16f);
        const v3 base = v(out.x * radius * r, out.y * radius * r, height * (0.45f + 0.5f * out.z * r));
        const v3 dir =
            unit(add(out, v(pick(s, stream, k + 4, -0.6f, 0.6f), pick(s, stream, k + 5, -0.6f, 0.6f), 0.2f)));
        const v3 side = mul(unit(cross(dir, add(out, v(0.1f, 0, 0.8f)))), 0.32f * length);
        const v3 tip = mul(dir, length);
        const float shape[10] = {base.x, base.y, base.z, tip.x, tip.y, tip.z, side.x, side.y, side.z, 0.35f * length};
        add_patch(s, patch_leaf, shape, 4, 2, LEAF, (uint32_t)(i + 1000 * (int)stream), where);
    }
}

#endif // SCENE_GEOMETRY_H
