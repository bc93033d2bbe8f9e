// scene_light.h - sky, sun, baked light and the colour a ray sees. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_LIGHT_H
#define SCENE_LIGHT_H

#include "scene_geometry.h"

static v3 clear_sky(const world* s, v3 d) { return mix(s->air.horizon, s->air.zenith, sqrtf(maxf(d.z, 0.0f))); }

static v3 sky(const world* s, v3 d) {
    const float up = maxf(d.z, 0.0f), toward = maxf(dot(d, s->air.sun_direction), 0.0f);
    v3 c = clear_sky(s, d);
    const v3 p = v(2.1f * d.x / (up + 0.25f), 2.1f * d.y / (up + 0.25f), s->layout ? (float)(s->seed % 61u) : 0.5f);
    const float cloud = step_between(0.48f, 0.72f, fbm(p, 5, 0)) * step_between(0.02f, 0.2f, up);
    c = mix(c, mul(v(1.15f, 1.12f, 1.08f), 0.75f + 0.4f * fbm(mul(p, 2.0f), 3, 0)), cloud);
    return s->air.sun_color.x > 0.0f ? add(c, mul(v(1.0f, 0.8f, 0.5f), 0.5f * powf(toward, 24.0f))) : c;
}

typedef struct hit {
    const surface* what;
    float t;
    v3 at, normal, local, local_normal, light; // normal faces the ray
    v3 face; // normal of the triangle, of any length and sign
} hit;

static int blocked(const world* s, v3 from, v3 d, float near, float far) {
    return is_crossed(&s->rays, from, d, near, far);
}

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

// Light that reaches a point with normal n from the sun and the lamps. r1, r2 in [0,1] choose points on their discs;
// the courtyard's sun is enlarged for soft shadows. Sets *sunny.
static v3 direct_light(const world* s, v3 from, v3 n, v3 true_normal, float r1, float r2, v3* to_sun, int* sunny) {
    v3 sum = v(0, 0, 0);
    *to_sun = around(s->air.sun_direction, r1, r2, s->layout == 0 ? 0.022f : 0.006f);
    const float facing = dot(n, *to_sun);
    *sunny = s->air.sun_color.x > 0.0f && facing > 0 && dot(true_normal, *to_sun) > 0 &&
             !blocked(s, from, *to_sun, 1e-3f, INFINITY);
    if (*sunny) sum = mul(s->air.sun_color, facing);
    for (int i = 0; i < s->lamp_count; i++) {
        const lamp* l = s->lamps + i;
        const v3 middle = sub(l->at, from), side = around(unit(middle), r1, r2, 1.0f);
        const v3 to = add(middle, mul(sub(side, unit(middle)), 0.7f * l->radius));
        const float squared = dot(to, to), distance = sqrtf(squared), cosine = dot(n, to) / distance;
        if (cosine <= 0 || dot(true_normal, to) <= 0 || distance <= l->radius) continue;
        if (blocked(s, from, mul(to, 1.0f / distance), 1e-3f, distance - l->radius)) continue;
        sum = add(sum, mul(l->color, cosine / squared));
    }
    return sum;
}

// ---- baked light -----------------------------------------------------------------
// Every vertex stores the diffuse light from the sky and the surroundings: one bounce in the courtyard, else two.

static v3 mean_albedo(material m) { // of the courtyard; small objects do not matter
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

typedef struct bake_job {
    world* s;
    int rays, bounce; // bounce 1: the vertices' light is that of bounce 0
    v3* out;          // per vertex
} bake_job;

static v3 bounced(const bake_job* job, const hit* h, float r1, float r2) {
    const world* s = job->s;
    if (s->layout == 0) {
        const float facing = dot(h->normal, s->air.sun_direction);
        v3 light = v(0.22f, 0.24f, 0.27f);
        if (facing > 0 && !blocked(s, add(h->at, mul(h->normal, 2e-3f)), s->air.sun_direction, 1e-3f, INFINITY))
            light = add(light, mul(s->air.sun_color, facing));
        return times(light, mean_albedo(h->what->m));
    }
    v3 to_sun;
    int sunny;
    const look l = look_at(h->what, h->local, h->local_normal, 0.2f);
    v3 light = direct_light(s, add(h->at, mul(h->normal, 2e-3f)), h->normal, h->normal, r1, r2, &to_sun, &sunny);
    if (job->bounce) light = add(light, h->light);
    const v3 albedo = l.mirror > 0.5f ? v(0.5f, 0.5f, 0.5f) : l.albedo;
    return add(times(light, albedo), l.glow);
}

static v3 gathered(const bake_job* job, size_t i) {
    const world* s = job->s;
    const vertex* x = s->vertices + i;
    const float shift_u = random3((int32_t)i, 1, 77), shift_w = random3((int32_t)i, 2, 77);
    v3 sum = v(0, 0, 0);
    for (int k = 0; k < job->rays; k++) {
        const float u = shift_u + 0.7548777f * (float)k, w = shift_w + 0.5698403f * (float)k; // R2 sequence
        const float fu = u - floorf(u), fw = w - floorf(w);
        const v3 d = around(x->normal, fu, fw, 1.0f);
        hit h;
        sum = add(sum, trace(s, add(x->at, mul(x->normal, 2e-3f)), d, 1e-3f, &h) ? bounced(job, &h, fw, fu)
                                                                                : clear_sky(s, d));
    }
    return mul(sum, 1.0f / (float)job->rays);
}

static void bake_patch(void* arg, size_t index, int32_t worker) {
    (void)worker;
    const bake_job* job = (const bake_job*)arg;
    const patch* p = job->s->patches + index;
    const size_t count = (size_t)(p->nu + 1) * (size_t)(p->nw + 1);
    if (job->s->layout != 0 && count < 10) { // a leaf
        const v3 light = gathered(job, p->first + count / 2);
        for (size_t i = 0; i < count; i++) job->out[p->first + i] = light;
        return;
    }
    for (size_t i = 0; i < count; i++) job->out[p->first + i] = gathered(job, p->first + i);
}

// Takes over the baked light; away from the courtyard, smoothed along the patch, which hides the noise of few rays.
static void settle_patch(void* arg, size_t index, int32_t worker) {
    (void)worker;
    const bake_job* job = (const bake_job*)arg;
    const patch* p = job->s->patches + index;
    const int row = p->nu + 1;
    for (int j = 0; j <= p->nw; j++)
        for (int i = 0; i <= p->nu; i++) {
            v3 sum = v(0, 0, 0);
            float total = 0.0f;
            const int reach = job->s->layout == 0 ? 0 : 2;
            for (int y = j - reach; y <= j + reach; y++)
                for (int x = i - reach; x <= i + reach; x++) {
                    if (x < 0 || y < 0 || x > p->nu || y > p->nw) continue;
                    const float weight = (float)((reach + 1 - abs(x - i)) * (reach + 1 - abs(y - j)));
                    sum = add(sum, mul(job->out[p->first + (size_t)(y * row + x)], weight));
                    total += weight;
                }
            job->s->vertices[p->first + (size_t)(j * row + i)].light = mul(sum, 1.0f / total);
        }
}

// Returns 0 if memory is short.
static int bake_light(gsf_context* ctx, world* s, int rays) {
    bake_job job = {s, rays, 0, (v3*)malloc(s->vertex_count * sizeof(v3))};
    for (; job.out && job.bounce < (s->layout == 0 ? 1 : 2); job.bounce++) {
        ctx->parallel.for_fn(ctx->parallel.user, s->patch_count, bake_patch, &job);
        ctx->parallel.for_fn(ctx->parallel.user, s->patch_count, settle_patch, &job);
    }
    const int ok = job.out != NULL;
    free(job.out);
    return ok;
}

// ---- colour ----------------------------------------------------------------------

// Normal of a surface with relief: the slope of the relief tilts it.
static v3 bumped(const hit* h, const look* l, float width) {
    const v3 n = h->normal;
    const float e = maxf(0.005f, width);
    const v3 t = unit(fabsf(n.z) < 0.8f ? cross(n, v(0, 0, 1)) : cross(n, v(1, 0, 0))), b = cross(n, t);
    const v3 lt = mul(rotate_z(t, -h->what->yaw), e), lb = mul(rotate_z(b, -h->what->yaw), e);
    const float ht = look_at(h->what, add(h->local, lt), h->local_normal, width).height;
    const float hb = look_at(h->what, add(h->local, lb), h->local_normal, width).height;
    const float limit = 0.6f, st = clampf((ht - l->height) / e, -limit, limit),
                sb = clampf((hb - l->height) / e, -limit, limit);
    return unit(sub(n, add(mul(t, st), mul(b, sb))));
}

static v3 shade(const world* s, const hit* h, v3 d, float r1, float r2, int depth);

// Colour of what a ray that starts on a surface sees in a reflection; a mirror shows it fully shaded.
static v3 reflected(const world* s, v3 from, v3 d, int mirror, float r1, float r2, int depth) {
    hit seen;
    if (!trace(s, from, d, 1e-3f, &seen)) return sky(s, d);
    if (mirror && depth < 2) return shade(s, &seen, d, r1, r2, depth + 1);
    const look l = look_at(seen.what, seen.local, seen.local_normal, 0.02f);
    return add(times(l.albedo, add(seen.light, s->air.fill)), l.glow);
}

// Colour of a ray's hit. r1, r2: see direct_light.
static v3 shade(const world* s, const hit* h, v3 d, float r1, float r2, int depth) {
    const float width = h->t * s->pixel_angle / maxf(fabsf(dot(h->normal, d)), 0.3f);
    const look l = look_at(h->what, h->local, h->local_normal, width);
    const v3 n = l.height != 0.0f && h->t < 6.0f && depth == 0 ? bumped(h, &l, width) : h->normal;
    const v3 from = add(h->at, mul(h->normal, 1e-3f));
    v3 to_sun;
    int lit;
    v3 light = add(h->light, direct_light(s, from, n, h->normal, r1, r2, &to_sun, &lit));
    const int leaf = h->what->m == LEAF || h->what->m == FOLIAGE || h->what->m == PETAL;
    if (leaf && !lit) light = add(light, mul(s->air.sun_color, 0.10f)); // translucency
    v3 c = add(times(l.albedo, light), l.glow);
    if (l.gloss > 0) {
        const float cosine = clampf(-dot(n, d), 0, 1), fresnel = 0.04f + 0.96f * powf(1 - cosine, 5.0f);
        const v3 mirror = sub(d, mul(n, 2 * dot(d, n)));
        if (l.gloss > 0.5f)
            c = add(c,
                    mul(reflected(s, from, mirror, l.mirror > 0.0f, r1, r2, depth), maxf(l.mirror, l.gloss * fresnel)));
        if (lit)
            c = add(c, mul(s->air.sun_color,
                           l.gloss * (0.25f + fresnel) *
                               powf(maxf(dot(mirror, s->air.sun_direction), 0.0f), 30.0f + 200.0f * l.gloss)));
    }
    return c;
}

#endif // SCENE_LIGHT_H
