// scene_light.h - sky, sun, baked light and the colour a ray sees. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_LIGHT_H
#define SCENE_LIGHT_H

#include "scene_geometry.h"

static const v3 sun_direction = {0.485f, -0.515f, 0.707f}, sun_color = {3.1f, 2.65f, 2.05f};

static v3 clear_sky(v3 d) { return mix(v(0.70f, 0.77f, 0.84f), v(0.20f, 0.38f, 0.74f), sqrtf(maxf(d.z, 0.0f))); }

static v3 sky(v3 d) {
    const float up = maxf(d.z, 0.0f), toward = maxf(dot(d, sun_direction), 0.0f);
    v3 c = clear_sky(d);
    const v3 p = v(2.1f * d.x / (up + 0.25f), 2.1f * d.y / (up + 0.25f), 0.5f);
    const float cloud = step_between(0.48f, 0.72f, fbm(p, 5, 0)) * step_between(0.02f, 0.2f, up);
    c = mix(c, mul(v(1.15f, 1.12f, 1.08f), 0.75f + 0.4f * fbm(mul(p, 2.0f), 3, 0)), cloud);
    return add(c, mul(v(1.0f, 0.8f, 0.5f), 0.5f * powf(toward, 24.0f)));
}

typedef struct hit {
    const surface* what;
    float t;
    v3 at, normal, local, local_normal, light; // normal faces the ray
    v3 face; // normal of the triangle, of any length and sign
} hit;

static int blocked(const world* s, v3 from, v3 d, float near, float far) { return is_crossed(&s->rays, from, d, near, far); }

static int trace(const world* s, v3 from, v3 d, float near, hit* out) {
    crossing x;
    if (!find_nearest(&s->rays, from, d, near, &x)) return 0;
    const triangle* t = s->triangles + x.triangle;
    const vertex *a = s->vertices + t->v[0], *b = s->vertices + t->v[1], *c = s->vertices + t->v[2];
    const float u = x.u, w = x.v, o = 1.0f - u - w;
    out->what = s->surfaces + x.triangle;
    out->t = x.t;
    out->face = x.face;
    out->at = add(from, mul(d, x.t));
    out->normal = unit(add(add(mul(a->normal, o), mul(b->normal, u)), mul(c->normal, w)));
    out->local = add(add(mul(a->local, o), mul(b->local, u)), mul(c->local, w));
    out->local_normal = rotate_z(out->normal, -out->what->yaw);
    out->light = add(add(mul(a->light, o), mul(b->light, u)), mul(c->light, w));
    if (dot(out->normal, d) > 0) out->normal = mul(out->normal, -1.0f);
    return 1;
}

static v3 around(v3 n, float u, float w, float spread) { // spread 1: cosine-weighted over the hemisphere of n
    const v3 t = unit(fabsf(n.z) < 0.8f ? cross(n, v(0, 0, 1)) : cross(n, v(1, 0, 0))), b = cross(n, t);
    const float r = spread * sqrtf(u), a = 6.2831853f * w;
    return unit(add(add(mul(t, r * cosf(a)), mul(b, r * sinf(a))), mul(n, sqrtf(1.0f - r * r))));
}

// Mean albedo for light that bounces once; small objects do not matter.
static v3 mean_albedo(material m) {
    switch (m) {
        case PAVING: return v(0.25f, 0.21f, 0.16f);
        case BRICK: return v(0.33f, 0.18f, 0.12f);
        case PLASTER: return v(0.36f, 0.30f, 0.18f);
        case LEAF: return v(0.14f, 0.22f, 0.05f);
        case CLOTH: return v(0.60f, 0.40f, 0.36f);
        case GLAZE: return v(0.60f, 0.60f, 0.62f);
        default: return v(0.30f, 0.22f, 0.16f);
    }
}

// Bakes diffuse light into every vertex: from the sky and, after one bounce, from sunlit surroundings.
typedef struct bake_job { world* s; int rays; } bake_job;
enum { BAKE_CHUNK = 512 };

static void bake_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const bake_job* job = (const bake_job*)arg;
    world* s = job->s;
    for (size_t i = chunk * BAKE_CHUNK; i < s->vertex_count && i < (chunk + 1) * BAKE_CHUNK; i++) {
        vertex* x = s->vertices + i;
        const float shift_u = random3((int32_t)i, 1, 77), shift_w = random3((int32_t)i, 2, 77);
        v3 sum = v(0, 0, 0);
        for (int k = 0; k < job->rays; k++) {
            const float u = shift_u + 0.7548777f * (float)k, w = shift_w + 0.5698403f * (float)k; // R2 sequence
            const v3 d = around(x->normal, u - floorf(u), w - floorf(w), 1.0f);
            hit h;
            if (!trace(s, add(x->at, mul(x->normal, 2e-3f)), d, 1e-3f, &h)) {
                sum = add(sum, clear_sky(d));
                continue;
            }
            const float facing = dot(h.normal, sun_direction);
            v3 light = v(0.22f, 0.24f, 0.27f);
            if (facing > 0 && !blocked(s, add(h.at, mul(h.normal, 2e-3f)), sun_direction, 1e-3f, INFINITY))
                light = add(light, mul(sun_color, facing));
            sum = add(sum, times(light, mean_albedo(h.what->m)));
        }
        x->light = mul(sum, 1.0f / (float)job->rays);
    }
}

// Colour of a ray's hit. r1, r2: random position on the sun's disc, which is enlarged for soft shadows.
static v3 shade(const world* s, const hit* h, v3 d, float r1, float r2) {
    const float width = h->t * s->pixel_angle / maxf(fabsf(dot(h->normal, d)), 0.3f);
    const look l = look_at(h->what->m, h->local, h->local_normal, h->what->seed, width);
    v3 n = h->normal;
    if (l.height != 0.0f && h->t < 6.0f) { // bump mapping: the slope of the relief tilts the normal
        const float e = maxf(0.005f, width);
        const v3 t = unit(fabsf(n.z) < 0.8f ? cross(n, v(0, 0, 1)) : cross(n, v(1, 0, 0))), b = cross(n, t);
        const v3 lt = mul(rotate_z(t, -h->what->yaw), e), lb = mul(rotate_z(b, -h->what->yaw), e);
        const float ht = look_at(h->what->m, add(h->local, lt), h->local_normal, h->what->seed, width).height;
        const float hb = look_at(h->what->m, add(h->local, lb), h->local_normal, h->what->seed, width).height;
        const float limit = 0.6f, st = clampf((ht - l.height) / e, -limit, limit),
                    sb = clampf((hb - l.height) / e, -limit, limit);
        n = unit(sub(n, add(mul(t, st), mul(b, sb))));
    }
    const v3 from = add(h->at, mul(h->normal, 1e-3f)), to_sun = around(sun_direction, r1, r2, 0.022f);
    const float facing = dot(n, to_sun);
    const int lit = facing > 0 && dot(h->normal, to_sun) > 0 && !blocked(s, from, to_sun, 1e-3f, INFINITY);
    v3 light = h->light;
    if (lit) light = add(light, mul(sun_color, facing));
    if (h->what->m == LEAF && !lit) light = add(light, mul(sun_color, 0.10f)); // translucency
    v3 c = times(l.albedo, light);
    if (l.gloss > 0) {
        const float cosine = clampf(-dot(n, d), 0, 1), fresnel = 0.04f + 0.96f * powf(1 - cosine, 5.0f);
        const v3 mirror = sub(d, mul(n, 2 * dot(d, n)));
        if (l.gloss > 0.5f) {
            hit seen;
            v3 image = sky(mirror);
            if (trace(s, from, mirror, 1e-3f, &seen))
                image = times(look_at(seen.what->m, seen.local, seen.local_normal, seen.what->seed, 0.02f).albedo,
                              add(seen.light, mul(sun_color, 0.3f)));
            c = add(c, mul(image, l.gloss * fresnel));
        }
        if (lit)
            c = add(c, mul(sun_color, l.gloss * (0.25f + fresnel) *
                                          powf(maxf(dot(mirror, sun_direction), 0.0f), 30.0f + 200.0f * l.gloss)));
    }
    return c;
}

#endif // SCENE_LIGHT_H
