// scene_objects.h - the things that furnish a scene. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_OBJECTS_H
#define SCENE_OBJECTS_H

#include "scene_geometry.h"

// ---- draws -----------------------------------------------------------------------
// One stream per scene, in the order in which it is built.

static float draw(world* s, float lo, float hi) { return pick(s, 60, s->draws++, lo, hi); }
static int draw_int(world* s, int count) { // 0 .. count-1
    const int i = (int)draw(s, 0.0f, (float)count);
    return i < count ? i : count - 1;
}
static uint32_t draw_seed(world* s) { return (uint32_t)draw_int(s, 1 << 20); }
static place place_at(float x, float y, float z, float yaw) {
    const place p = {{x, y, z}, yaw};
    return p;
}
// A place given in the axes of another.
static place within(place outer, float x, float y, float z, float yaw) {
    const place p = {add(outer.at, rotate_z(v(x, y, z), outer.yaw)), outer.yaw + yaw};
    return p;
}

// ---- flat shapes -----------------------------------------------------------------

static int cells_of(float length, float cell) { return (int)clampf(ceilf(length / cell), 1.0f, 90.0f); }

// A rectangle from a corner; it faces edge_u x edge_w.
static void add_sheet(world* s, v3 corner, v3 edge_u, v3 edge_w, float cell, material m, uint32_t seed, place where) {
    const float shape[9] = {corner.x, corner.y, corner.z, edge_u.x, edge_u.y, edge_u.z, edge_w.x, edge_w.y, edge_w.z};
    add_patch(s, patch_rectangle, shape, cells_of(sqrtf(dot(edge_u, edge_u)), cell),
              cells_of(sqrtf(dot(edge_w, edge_w)), cell), m, seed, where);
}

static void add_block(world* s, v3 lo, v3 hi, float cell, material m, uint32_t seed, place where) {
    const v3 d = sub(hi, lo), x = v(d.x, 0, 0), y = v(0, d.y, 0), z = v(0, 0, d.z);
    add_sheet(s, v(lo.x, lo.y, hi.z), x, y, cell, m, seed, where);
    add_sheet(s, lo, y, x, cell, m, seed, where);
    add_sheet(s, lo, x, z, cell, m, seed, where);
    add_sheet(s, v(lo.x, hi.y, lo.z), z, x, cell, m, seed, where);
    add_sheet(s, lo, z, y, cell, m, seed, where);
    add_sheet(s, v(hi.x, lo.y, lo.z), y, z, cell, m, seed, where);
}

// A panel (see look_panel) around a centre; seen from the front, `right` and `up` are unit vectors in the object's
// axes.
static void add_panel(world* s, v3 center, v3 right, v3 up, float width, float height, material m, uint32_t seed,
                      place where) {
    const v3 corner = sub(sub(center, mul(right, 0.5f * width)), mul(up, 0.5f * height));
    const size_t first = s->vertex_count, first_triangle = s->triangle_count;
    const int nu = cells_of(width, 0.2f), nw = cells_of(height, 0.2f);
    add_sheet(s, corner, mul(right, width), mul(up, height), 0.2f, m, seed, where);
    if (s->failed) return;
    for (size_t i = first; i < s->vertex_count; i++) {
        const int k = (int)(i - first), row = k / (nu + 1);
        s->vertices[i].local =
            v(((float)(k % (nu + 1)) / (float)nu - 0.5f) * width / height, (float)row / (float)nw - 0.5f, height);
    }
    for (size_t i = first_triangle; i < s->triangle_count; i++) s->surfaces[i].aspect = width / height;
}

// A panel on a wall: it faces `yaw` in the object's axes.
static void hang_panel(world* s, v3 center, float yaw, float width, float height, material m, uint32_t seed,
                       place where) {
    add_panel(s, center, v(-sinf(yaw), cosf(yaw), 0), v(0, 0, 1), width, height, m, seed, where);
}

// ---- round shapes ----------------------------------------------------------------

static v3 patch_tube(float u, float w, const float* s) { // ends, radii, sag
    const v3 a = v(s[0], s[1], s[2]), axis = v(s[3] - s[0], s[4] - s[1], s[5] - s[2]), d = unit(axis);
    const v3 t = unit(fabsf(d.z) < 0.8f ? cross(d, v(0, 0, 1)) : cross(d, v(1, 0, 0))), b = cross(d, t);
    const float angle = 6.2831853f * u, r = s[6] + w * (s[7] - s[6]);
    const v3 p = add(add(a, mul(axis, w)), add(mul(t, r * cosf(angle)), mul(b, r * sinf(angle))));
    return v(p.x, p.y, p.z - 4.0f * s[8] * w * (1.0f - w));
}
static v3 patch_disc(float u, float w, const float* s) { // radius, height; faces up
    const float a = 6.2831853f * u, r = s[0] * (1.0f - w);
    return v(cosf(a) * r, sinf(a) * r, s[1]);
}
static float bent(float x, float power) { return (x < 0 ? -1.0f : 1.0f) * powf(fabsf(x), power); }
static v3 patch_cushion(float u, float w, const float* s) { // half axes, roundness (1: an ellipsoid, 0: a box)
    const float a = 6.2831853f * u, b = 3.1415927f * (w - 0.5f), e = s[3];
    return v(s[0] * bent(cosf(a), e) * bent(cosf(b), e), s[1] * bent(sinf(a), e) * bent(cosf(b), e),
             s[2] * bent(sinf(b), e));
}
static v3 patch_knot(float u, float w, const float* s) { // radius of the whole, of the tube; p, q
    const float t = 6.2831853f * w, e = 1e-3f;
    v3 at[2];
    for (int i = 0; i < 2; i++) {
        const float a = t + e * (float)i, r = s[0] * (0.68f + 0.32f * cosf(s[3] * a));
        at[i] = v(r * cosf(s[2] * a), r * sinf(s[2] * a), 0.45f * s[0] * sinf(s[3] * a));
    }
    const v3 d = unit(sub(at[1], at[0])), side = unit(cross(d, v(at[0].x, at[0].y, 0.3f * s[0]))), b = cross(d, side);
    const v3 p = add(at[0], sub(mul(side, s[1] * cosf(6.2831853f * u)), mul(b, s[1] * sinf(6.2831853f * u))));
    return v(p.x, p.z, p.y + 1.05f * s[0]); // upright
}
static v3 patch_drape(float u, float w, const float* s) { // a curtain: width, height, depth of the folds, their number
    const float fold = sinf(6.2831853f * s[3] * u + 1.3f * sinf(9.0f * u)) * s[2] * (0.5f + 0.5f * (1 - w));
    return v(s[0] * (u - 0.5f), -fold, s[1] * w);
}

static void add_tube(world* s, v3 a, v3 b, float r0, float r1, int sides, material m, uint32_t seed, place where) {
    const float shape[9] = {a.x, a.y, a.z, b.x, b.y, b.z, r0, r1, 0};
    const float length = sqrtf(dot(sub(b, a), sub(b, a)));
    add_patch(s, patch_tube, shape, sides, cells_of(length, 0.3f), m, seed, where);
}
static void add_cable(world* s, v3 a, v3 b, float r, float sag, material m, place where) {
    const float shape[9] = {a.x, a.y, a.z, b.x, b.y, b.z, r, r, sag};
    add_patch(s, patch_tube, shape, 5, 24, m, 1, where);
}
static void add_ball(world* s, float radius, material m, uint32_t seed, place where) { // around the place
    const float shape[4] = {radius, 1, 0, 0};
    add_patch(s, patch_sphere, shape, 28, 18, m, seed, where);
}
static void add_cushion(world* s, v3 half, float round, material m, uint32_t seed, place where) {
    const float shape[4] = {half.x, half.y, half.z, round};
    add_patch(s, patch_cushion, shape, 28, 18, m, seed, where);
}
static void add_disc(world* s, float radius, float z, material m, uint32_t seed, place where) {
    const float shape[2] = {radius, z};
    add_patch(s, patch_disc, shape, 24, 3, m, seed, where);
}

// A vessel whose profile, pairs of radius and height, is scaled to the given size.
static void add_lathe(world* s, const float* profile, float radius, float height, int sides, int rings, material m,
                      uint32_t seed, place where) {
    float shape[40], widest = 0.0f, highest_z = 0.0f;
    const int n = (int)profile[0];
    for (int i = 0; i < n; i++)
        widest = maxf(widest, profile[1 + 2 * i]), highest_z = maxf(highest_z, profile[2 + 2 * i]);
    shape[0] = profile[0];
    for (int i = 0; i < n; i++) {
        shape[1 + 2 * i] = profile[1 + 2 * i] * radius / widest;
        shape[2 + 2 * i] = profile[2 + 2 * i] * height / highest_z;
    }
    add_patch(s, patch_lathe, shape, sides, rings, m, seed, where);
}

static const float profiles[8][20] = {
    {9, 0, 0, 0.5f, 0, 0.55f, 0.1f, 0.9f, 0.4f, 1, 0.7f, 0.75f, 1.1f, 0.35f, 1.4f, 0.4f, 1.6f, 0.55f, 1.7f}, // vase
    {8, 0, 0, 0.95f, 0, 1, 0.06f, 1, 0.6f, 1, 1.2f, 0.35f, 1.5f, 0.3f, 1.8f, 0.32f, 1.95f},                  // bottle
    {7, 0, 0, 0.4f, 0, 0.45f, 0.08f, 0.9f, 0.4f, 1.0f, 0.75f, 0.97f, 0.75f, 0.5f, 0.25f},                    // bowl
    {8, 0, 0, 0.8f, 0, 0.82f, 0.05f, 0.95f, 0.5f, 1, 1, 0.97f, 1.02f, 0.9f, 1.0f, 0.7f, 0.2f},               // cup
    {9, 0, 0, 0.6f, 0, 0.65f, 0.1f, 1, 0.6f, 1, 0.95f, 0.6f, 1.25f, 0.65f, 1.3f, 0.1f, 1.45f, 0.12f,
     1.6f}, // jar with a lid
    {9, 0, 0, 1, 0, 0.9f, 0.08f, 0.25f, 0.2f, 0.18f, 0.9f, 0.3f, 1.0f, 0.16f, 1.1f, 0.4f, 1.75f, 0.3f,
     1.8f},                                                                                             // candlestick
    {8, 0, 0, 0.7f, 0, 0.78f, 0.2f, 0.95f, 0.85f, 1.05f, 0.95f, 1.05f, 1.1f, 0.9f, 1.08f, 0.86f, 0.9f}, // flower pot
    {8, 0, 0, 0.3f, 0.05f, 0.95f, 0.5f, 1, 0.9f, 0.85f, 1.25f, 0.45f, 1.5f, 0.2f, 1.7f, 0.0f, 1.75f}};  // pear, pawn

// ---- plants ----------------------------------------------------------------------

static void add_leaf(world* s, v3 base, v3 dir, float length, float wide, material m, uint32_t seed, place where) {
    const v3 tip = mul(dir, length), side = mul(unit(cross(dir, v(0.2f, 0.1f, 1.0f))), 0.5f * wide);
    const float shape[10] = {base.x, base.y, base.z, tip.x, tip.y, tip.z, side.x, side.y, side.z, 0.3f * length};
    add_patch(s, patch_leaf, shape, 3, 1, m, seed, where);
}

static v3 draw_direction(world* s, float lowest_z) {
    const float z = draw(s, lowest_z, 1.0f), a = draw(s, 0, 6.2831853f), r = sqrtf(maxf(1.0f - z * z, 0.0f));
    return v(r * cosf(a), r * sinf(a), z);
}

// A crown of leaves in an ellipsoid around the place; blossoms: share of petals.
static void add_crown(world* s, v3 half, int leaves, float length, uint32_t species, float blossoms, place where) {
    for (int i = 0; i < leaves; i++) {
        const v3 out = draw_direction(s, -1.0f);
        const float r = cbrtf(draw(s, 0.25f, 1.0f));
        const v3 base = v(out.x * half.x * r, out.y * half.y * r, out.z * half.z * r);
        const v3 dir = unit(add(out, v(draw(s, -0.9f, 0.9f), draw(s, -0.9f, 0.9f), draw(s, -0.5f, 0.7f))));
        const float size = length * draw(s, 0.7f, 1.3f);
        const int petal = r > 0.8f && draw(s, 0, 1) < blossoms;
        add_leaf(s, base, dir, petal ? 0.6f * size : size, petal ? 0.55f * size : 0.45f * size, petal ? PETAL : FOLIAGE,
                 species << 16 | (uint32_t)i, where);
    }
}

static void add_potted_plant(world* s, float size, place where) {
    const uint32_t species = draw_seed(s);
    const int kind = draw_int(s, 3);
    add_lathe(s, profiles[6], 0.19f * size, 0.32f * size, 28, 16, draw(s, 0, 1) < 0.5f ? TERRACOTTA : GLASSY,
              draw_seed(s), where);
    add_disc(s, 0.16f * size, 0.27f * size, SOIL, 0, where);
    if (kind == 0) { // blades
        for (int i = 0; i < 46; i++) {
            const v3 d = unit(add(draw_direction(s, 0.2f), v(0, 0, 0.8f)));
            add_leaf(s, v(0.05f * d.x, 0.05f * d.y, 0.27f * size), d, draw(s, 0.4f, 0.85f) * size, 0.06f * size,
                     FOLIAGE, species << 16 | (uint32_t)i, where);
        }
    } else { // a bush, sometimes on a stem
        const float up = kind == 1 ? 0.52f : 0.95f;
        add_tube(s, v(0, 0, 0.2f * size), v(0, 0, up * size), 0.02f * size, 0.012f * size, 7, BARK, species, where);
        add_crown(s, mul(v(0.30f, 0.30f, 0.30f), size), 240, 0.13f * size, species, draw(s, -0.3f, 0.35f),
                  within(where, 0, 0, up * size, 0));
    }
}

static void add_tree(world* s, float height, int leaves, place where) {
    const uint32_t species = draw_seed(s);
    const float lean = draw(s, -0.15f, 0.15f), trunk = 0.5f * height, blossoms = draw(s, -0.6f, 0.3f);
    add_tube(s, v(0, 0, -0.1f), v(lean * trunk, 0, trunk), 0.045f * height, 0.028f * height, 14, BARK, species, where);
    const int boughs = 6;
    for (int i = 0; i < boughs; i++) {
        const float a = 6.2831853f * ((float)i + draw(s, 0, 0.6f)) / (float)boughs,
                    out = draw(s, 0.16f, 0.27f) * height;
        const float from = draw(s, 0.6f, 1.0f);
        const v3 base = v(lean * trunk * from, 0, trunk * from);
        const v3 tip = add(v(lean * trunk, 0, trunk), v(out * cosf(a), out * sinf(a), draw(s, 0.10f, 0.34f) * height));
        add_tube(s, base, tip, 0.02f * height, 0.006f * height, 7, BARK, species, where);
        add_crown(s, mul(v(0.17f, 0.17f, 0.13f), height), leaves / (boughs + 1), 0.042f * height, species, blossoms,
                  within(where, tip.x, tip.y, tip.z, 0));
    }
    add_crown(s, mul(v(0.2f, 0.2f, 0.15f), height), leaves / (boughs + 1), 0.042f * height, species, blossoms,
              within(where, lean * trunk, 0, 0.86f * height, 0));
}

static void add_hedge(world* s, float length, float depth, float height, place where) { // along x
    const uint32_t species = draw_seed(s);
    const int leaves = (int)(380.0f * length * height);
    add_block(s, v(-0.5f * length, -0.4f * depth, 0), v(0.5f * length, 0.4f * depth, 0.95f * height), 0.3f, LEAVES,
              species << 16, where);
    for (int i = 0; i < leaves; i++) {
        const float x = draw(s, -0.5f, 0.5f) * length, z = draw(s, 0.0f, height);
        const int face = draw_int(s, 5); // front, front, back, back, top
        const v3 base = face == 4 ? v(x, draw(s, -0.45f, 0.45f) * depth, 0.93f * height)
                                  : v(x, (face < 2 ? -0.4f : 0.4f) * depth, z);
        const v3 out = face == 4 ? v(0, 0, 1) : v(0, face < 2 ? -1.0f : 1.0f, 0.2f);
        add_leaf(s, base, unit(add(out, mul(draw_direction(s, -0.8f), 0.9f))), draw(s, 0.06f, 0.11f), 0.05f, FOLIAGE,
                 species << 16 | (uint32_t)i, where);
    }
}

static void add_flowers(world* s, float length, float depth, int count, place where) { // a bed along x
    const uint32_t species = draw_seed(s);
    add_sheet(s, v(-0.5f * length, -0.5f * depth, 0.02f), v(length, 0, 0), v(0, depth, 0), 0.2f, SOIL, 0, where);
    for (int i = 0; i < count; i++) {
        const float x = draw(s, -0.48f, 0.48f) * length, y = draw(s, -0.45f, 0.45f) * depth, z = draw(s, 0.14f, 0.42f);
        const uint32_t kind = species + (uint32_t)(i % 3);
        const v3 head = v(x + draw(s, -0.05f, 0.05f), y + draw(s, -0.05f, 0.05f), z);
        add_tube(s, v(x, y, 0), head, 0.004f, 0.003f, 4, FOLIAGE, species << 16, where);
        for (int k = 0; k < 3; k++)
            add_leaf(s, v(x, y, 0.02f + 0.05f * (float)k), draw_direction(s, 0.2f), 0.13f, 0.035f, FOLIAGE,
                     species << 16 | (uint32_t)i, where);
        for (int k = 0; k < 6; k++) {
            const float a = 1.0471976f * (float)k;
            add_leaf(s, head, v(0.9f * cosf(a), 0.9f * sinf(a), 0.43f), 0.05f, 0.045f, PETAL, kind << 16 | (uint32_t)i,
                     where);
        }
    }
}

// ---- furniture -------------------------------------------------------------------

static void add_table(world* s, float length, float depth, float height, uint32_t seed, place where) {
    add_block(s, v(-0.5f * length, -0.5f * depth, height - 0.035f), v(0.5f * length, 0.5f * depth, height), 0.06f, WOOD,
              seed, where);
    for (int i = 0; i < 4; i++) {
        const float x = (i & 1 ? 0.5f : -0.5f) * (length - 0.14f), y = (i & 2 ? 0.5f : -0.5f) * (depth - 0.12f);
        add_block(s, v(x - 0.032f, y - 0.032f, 0), v(x + 0.032f, y + 0.032f, height - 0.035f), 0.2f, WOOD, seed | 256u,
                  where);
    }
    for (int i = -1; i <= 1; i += 2) {
        const float y = (float)i * (0.5f * depth - 0.06f);
        add_block(s, v(-0.5f * length + 0.07f, y - 0.012f, height - 0.13f),
                  v(0.5f * length - 0.07f, y + 0.012f, height - 0.035f), 0.2f, WOOD, seed, where);
    }
}

static void add_chair(world* s, uint32_t seed, place where) { // faces +y, seat at 0.45
    const int slats = 3 + (int)(seed % 4u);
    add_block(s, v(-0.21f, -0.21f, 0.42f), v(0.21f, 0.21f, 0.455f), 0.1f, WOOD, seed, where);
    for (int i = 0; i < 4; i++) {
        const float x = i & 1 ? 0.18f : -0.18f, y = i & 2 ? 0.18f : -0.18f;
        add_tube(s, v(1.1f * x, 1.1f * y, 0), v(x, y, 0.43f), 0.014f, 0.02f, 8, WOOD, seed | 256u, where);
        if (i < 2) add_tube(s, v(x, y, 0.43f), v(x, y - 0.07f, 0.95f), 0.018f, 0.015f, 8, WOOD, seed | 256u, where);
    }
    add_tube(s, v(-0.18f, -0.25f, 0.94f), v(0.18f, -0.25f, 0.94f), 0.022f, 0.022f, 8, WOOD, seed, where);
    for (int i = 0; i < slats; i++) {
        const float x = -0.18f + 0.36f * ((float)i + 0.5f) / (float)slats;
        add_tube(s, v(x, -0.18f, 0.45f), v(x, -0.25f, 0.94f), 0.008f, 0.008f, 6, WOOD, seed | 256u, where);
    }
    for (int i = -1; i <= 1; i += 2)
        add_tube(s, v(0.19f * (float)i, -0.19f, 0.2f), v(0.19f * (float)i, 0.19f, 0.2f), 0.009f, 0.009f, 6, WOOD, seed,
                 where);
    if (seed & 64u) add_cushion(s, v(0.19f, 0.19f, 0.03f), 0.45f, FABRIC, seed, within(where, 0, 0, 0.485f, 0));
}

static void add_sofa(world* s, float length, uint32_t seed, place where) { // faces +y
    const float half = 0.5f * length;
    add_cushion(s, v(half, 0.40f, 0.14f), 0.18f, FABRIC, seed, within(where, 0, 0.02f, 0.22f, 0));
    add_cushion(s, v(half, 0.11f, 0.34f), 0.22f, FABRIC, seed, within(where, 0, -0.34f, 0.52f, 0));
    for (int i = -1; i <= 1; i += 2)
        add_cushion(s, v(0.10f, 0.42f, 0.24f), 0.25f, FABRIC, seed, within(where, (float)i * half, 0, 0.38f, 0));
    const int seats = length > 1.5f ? 3 : 2;
    for (int i = 0; i < seats; i++) {
        const float x = ((float)i + 0.5f) / (float)seats * (length - 0.2f) - half + 0.1f;
        add_cushion(s, v(0.48f * (length - 0.2f) / (float)seats, 0.34f, 0.08f), 0.3f, FABRIC, seed,
                    within(where, x, 0.08f, 0.43f, 0));
        if (i != 1)
            add_cushion(s, v(0.2f, 0.07f, 0.2f), 0.55f, FABRIC, draw_seed(s),
                        within(where, x, -0.14f, 0.64f, draw(s, -0.3f, 0.3f)));
    }
}

static void add_book(world* s, float thick, float depth, float height, place where) { // stands, spine towards -y
    const uint32_t seed = draw_seed(s);
    add_block(s, v(0, 0, 0), v(thick, depth, height), 0.5f, ENAMEL, seed, where);
    add_block(s, v(0.1f * thick, 0.01f, 0.01f), v(0.9f * thick, depth - 0.005f, height + 0.001f), 0.5f, PAGES, seed,
              where);
    add_panel(s, v(0.5f * thick, -0.0015f, 0.5f * height), v(1, 0, 0), v(0, 0, 1), thick, height, SPINE, seed, where);
}

static void add_books(world* s, float length, float depth, float highest_book, place where) { // a row along x
    for (float x = 0.0f; x < length;) {
        const float thick = draw(s, 0.018f, 0.055f), height = highest_book * draw(s, 0.66f, 0.97f);
        if (x + thick > length) return;
        add_book(s, thick, depth * draw(s, 0.72f, 0.98f), height, within(where, x, draw(s, 0.0f, 0.03f), 0, 0));
        x += thick + draw(s, 0.0f, 0.003f);
    }
}

static void add_cube(world* s, float size, uint32_t seed, place where) { // a toy block with signs
    add_block(s, v(-0.5f * size, -0.5f * size, 0), v(0.5f * size, 0.5f * size, size), 0.1f, ENAMEL, seed, where);
    for (int i = 0; i < 4; i++)
        hang_panel(
            s, v(0.505f * size * cosf(1.5707963f * (float)i), 0.505f * size * sinf(1.5707963f * (float)i), 0.5f * size),
            1.5707963f * (float)i, 0.84f * size, 0.84f * size, SIGN, seed + (uint32_t)i, where);
}

// One of many small things, about `size` high, on a horizontal surface.
static void add_trinket(world* s, float size, place where) {
    const uint32_t seed = draw_seed(s);
    switch (draw_int(s, 14)) {
        case 0: add_lathe(s, profiles[0], 0.33f * size, size, 32, 32, GLASSY, seed, where); return;
        case 1:
            add_lathe(s, profiles[1], 0.2f * size, size, 24, 24, draw(s, 0, 1) < 0.6f ? LABEL : CHROME, seed, where);
            return;
        case 2: { // bowl of fruit
            add_lathe(s, profiles[2], 0.6f * size, 0.42f * size, 36, 28, draw(s, 0, 1) < 0.7f ? GLASSY : WOOD, seed,
                      where);
            const float apple[1] = {0.2f * size}, orange[4] = {0.2f * size, 0.95f, 0.02f, 1};
            for (int i = 0; i < 5; i++) {
                const float a = 1.2566371f * (float)i, r = i == 4 ? 0 : 0.24f * size;
                const place at = within(where, r * cosf(a), r * sinf(a), i == 4 ? 0.62f * size : 0.40f * size, a);
                if ((seed >> i) & 1u) add_patch(s, patch_apple, apple, 22, 16, APPLE, seed + (uint32_t)i, at);
                else add_patch(s, patch_sphere, orange, 22, 16, ORANGE, seed + (uint32_t)i, at);
            }
            return;
        }
        case 3: { // cup with a handle
            const float ring[2] = {0.24f * size, 0.05f * size};
            add_lathe(s, profiles[3], 0.38f * size, 0.75f * size, 32, 24, GLASSY, seed, where);
            add_patch(s, patch_knot, (const float[4]){ring[0], ring[1], 1, 0}, 10, 24, GLASSY, seed,
                      within(where, 0.40f * size, 0, 0.1f * size, 0));
            return;
        }
        case 4:
            add_lathe(s, profiles[4], 0.36f * size, 0.9f * size, 32, 30, draw(s, 0, 1) < 0.5f ? LABEL : GLASSY, seed,
                      where);
            return;
        case 5:
            add_lathe(s, profiles[5], 0.26f * size, 0.8f * size, 24, 30, METAL, seed, where);
            add_tube(s, v(0, 0, 0.78f * size), v(0, 0, 1.15f * size), 0.05f * size, 0.045f * size, 14, PAGES, seed,
                     where);
            return;
        case 6: // tin
            add_tube(s, v(0, 0, 0), v(0, 0, 0.75f * size), 0.3f * size, 0.3f * size, 32, LABEL, seed, where);
            add_disc(s, 0.3f * size, 0.75f * size, CHROME, seed, where);
            return;
        case 7: { // a ball
            add_ball(s, 0.4f * size, FABRIC, seed, within(where, 0, 0, 0.4f * size, 0));
            return;
        }
        case 8: // blocks
            add_cube(s, 0.42f * size, seed, where);
            add_cube(s, 0.38f * size, seed + 9u, within(where, 0.05f * size, 0.02f * size, 0.425f * size, 0.5f));
            add_cube(s, 0.34f * size, seed + 17u, within(where, 0.47f * size, -0.1f * size, 0, 0.9f));
            return;
        case 9:
            add_patch(s, patch_knot, (const float[4]){0.42f * size, 0.11f * size, 2, 3}, 14, 110,
                      draw(s, 0, 1) < 0.5f ? METAL : MARBLE, seed, where);
            return;
        case 10: // lying books
            for (int i = 0; i < 4; i++) {
                const float z = 0.2f * size * (float)i, w = 0.42f * size - 0.03f * size * (float)i;
                const place at = within(where, 0, 0, z, draw(s, -0.5f, 0.5f));
                add_block(s, v(-w, -0.65f * w, 0.02f * size), v(w - 0.02f * size, 0.64f * w, 0.17f * size), 0.2f, PAGES,
                          seed, at);
                add_block(s, v(-w, -0.66f * w, 0), v(w, 0.66f * w, 0.02f * size), 0.2f, ENAMEL, seed + (uint32_t)i, at);
                add_block(s, v(-w, -0.66f * w, 0.17f * size), v(w, 0.66f * w, 0.19f * size), 0.2f, ENAMEL,
                          seed + (uint32_t)i, at);
                add_panel(s, v(0, -0.665f * w, 0.095f * size), v(0, 0, -1), v(1, 0, 0), 0.19f * size, 2 * w, SPINE,
                          seed + 7u * (uint32_t)i, at);
            }
            return;
        case 11: { // a globe on a stand
            add_lathe(s, profiles[5], 0.24f * size, 0.4f * size, 20, 20, WOOD, seed, where);
            add_ball(s, 0.34f * size, BALL, seed, within(where, 0, 0, 0.68f * size, 0));
            add_patch(s, patch_knot, (const float[4]){0.38f * size, 0.012f * size, 1, 0}, 6, 40, CHROME, seed,
                      within(where, 0, 0, 0.68f * size - 1.05f * 0.38f * size, 0.4f));
            return;
        }
        case 12: // a framed picture that leans back
            add_panel(s, v(0, 0, 0.46f * size), v(1, 0, 0), unit(v(0, 0.2f, 1)), 0.74f * size, 0.92f * size, PICTURE,
                      seed, where);
            add_block(s, v(-0.3f * size, 0.02f * size, 0), v(0.3f * size, 0.11f * size, 0.1f * size), 0.2f, WOOD, seed,
                      where);
            return;
        default: add_potted_plant(s, 1.1f * size, where);
    }
}

static void add_lamp_bulb(world* s, v3 at, v3 color, float radius) {
    const lamp l = {at, color, radius};
    if (s->lamp_count < (int)(sizeof s->lamps / sizeof *s->lamps)) s->lamps[s->lamp_count++] = l;
}

static void add_standing_lamp(world* s, float height, float power, place where) {
    static const float shade_profile[] = {4, 1.0f, 0.0f, 0.9f, 0.3f, 0.75f, 0.7f, 0.6f, 1.0f};
    const v3 top = add(where.at, v(0, 0, height));
    add_disc(s, 0.15f, 0.02f, METAL, 3, where);
    add_tube(s, v(0, 0, 0), v(0, 0, height - 0.12f), 0.012f, 0.012f, 8, METAL, 3, where);
    add_lathe(s, shade_profile, 0.2f, 0.28f, 28, 8, GLOW, draw_seed(s), within(where, 0, 0, height - 0.14f, 0));
    add_lamp_bulb(s, top, mul(v(1.0f, 0.74f, 0.46f), power), 0.26f);
}

static void add_pendant(world* s, v3 at, float ceiling, float power) { // hangs from the ceiling
    const place where = {at, 0};
    static const float bell[] = {5, 0.1f, 0.22f, 0.5f, 0.2f, 0.8f, 0.1f, 1.0f, 0.0f, 0.98f, 0.0f};
    add_tube(s, v(0, 0, 0.2f), v(0, 0, ceiling - at.z), 0.006f, 0.006f, 5, METAL, 1, where);
    add_lathe(s, bell, 0.22f, 0.2f, 28, 12, ENAMEL, draw_seed(s), where);
    add_ball(s, 0.06f, GLOW, 1, within(where, 0, 0, 0.04f, 0));
    add_lamp_bulb(s, add(at, v(0, 0, 0.03f)), mul(v(1.0f, 0.82f, 0.60f), power), 0.12f);
}

// Bars between two rails, from the place along x.
static void add_railing(world* s, float length, float height, float step, float r, material m, uint32_t seed,
                        place where) {
    const int bars = (int)(length / step);
    for (int i = 0; i <= bars; i++) {
        const float x = length * (float)i / (float)maxf((float)bars, 1.0f);
        add_tube(s, v(x, 0, 0), v(x, 0, height), r, r, 5, m, seed, where);
        if (i % 8 == 0) {
            add_tube(s, v(x, 0, -0.05f), v(x, 0, height + 0.1f), 2.2f * r, 2.2f * r, 7, m, seed, where);
            add_ball(s, 3.2f * r, m, seed, within(where, x, 0, height + 0.1f, 0));
        }
    }
    add_tube(s, v(0, 0, 0.08f), v(length, 0, 0.08f), 1.4f * r, 1.4f * r, 6, m, seed, where);
    add_tube(s, v(0, 0, height - 0.06f), v(length, 0, height - 0.06f), 1.6f * r, 1.6f * r, 6, m, seed, where);
}

static void add_pickets(world* s, float length, float height, uint32_t seed,
                        place where) { // a fence of boards along x
    const int count = (int)(length / 0.13f);
    for (int i = 0; i < count; i++) {
        const float x = 0.13f * (float)i, top = height * (1.0f + 0.04f * sinf(2.1f * (float)i));
        add_block(s, v(x, -0.012f, 0.05f), v(x + 0.085f, 0.012f, top), 0.4f, seed & 1u ? WOOD : ENAMEL,
                  (seed & ~255u) | 256u | (seed & 7u), where);
    }
    for (int i = 0; i < 2; i++) {
        const float z = i ? 0.78f * height : 0.25f * height;
        add_block(s, v(0, 0.012f, z), v(length, 0.045f, z + 0.07f), 0.4f, WOOD, seed, where);
    }
}

static void add_wheel(world* s, float radius, place where) { // in the plane of x and z
    add_patch(s, patch_knot, (const float[4]){radius, 0.018f, 1, 0}, 8, 48, METAL, 2,
              within(where, 0, 0, -0.05f * radius, 0));
    for (int i = 0; i < 14; i++) {
        const float a = 0.44879895f * (float)i;
        add_tube(s, v(0, i & 1 ? 0.02f : -0.02f, radius), v(radius * cosf(a), 0, radius + radius * sinf(a)), 0.003f,
                 0.003f, 4, CHROME, 1, where);
    }
    add_ball(s, 0.03f, CHROME, 1, within(where, 0, 0, radius, 0));
}

static void add_bicycle(world* s, place where) { // along x
    const uint32_t seed = draw_seed(s);
    const v3 rear = v(-0.52f, 0, 0.33f), front = v(0.52f, 0, 0.33f), crank = v(-0.08f, 0, 0.30f),
             seat = v(-0.22f, 0, 0.80f), head = v(0.36f, 0, 0.82f);
    add_wheel(s, 0.33f, within(where, rear.x, 0, 0, 0));
    add_wheel(s, 0.33f, within(where, front.x, 0, 0, 0));
    const v3 bars[7][2] = {{rear, crank},
                           {rear, seat},
                           {crank, seat},
                           {crank, head},
                           {seat, head},
                           {head, front},
                           {head, v(0.34f, 0, 0.98f)}};
    for (int i = 0; i < 7; i++) add_tube(s, bars[i][0], bars[i][1], 0.016f, 0.016f, 8, ENAMEL, seed, where);
    add_tube(s, v(0.30f, -0.27f, 0.99f), v(0.30f, 0.27f, 0.99f), 0.012f, 0.012f, 7, CHROME, seed, where);
    add_cushion(s, v(0.13f, 0.07f, 0.035f), 0.6f, METAL, seed, within(where, -0.24f, 0, 0.86f, 0));
    for (int i = 0; i < 2; i++)
        add_tube(s, crank, add(crank, v(i ? 0.12f : -0.12f, i ? 0.09f : -0.09f, i ? -0.1f : 0.1f)), 0.012f, 0.012f, 6,
                 METAL, 1, where);
}

static void add_bench(world* s, uint32_t seed, place where) { // faces +y
    for (int i = 0; i < 4; i++)
        add_block(s, v(-0.8f, -0.2f + 0.12f * (float)i, 0.42f), v(0.8f, -0.11f + 0.12f * (float)i, 0.45f), 0.2f, WOOD,
                  seed, where);
    for (int i = 0; i < 3; i++)
        add_block(s, v(-0.8f, -0.27f, 0.55f + 0.13f * (float)i), v(0.8f, -0.245f, 0.64f + 0.13f * (float)i), 0.2f, WOOD,
                  seed, where);
    for (int i = -1; i <= 1; i += 2) {
        const float x = 0.68f * (float)i;
        add_block(s, v(x - 0.025f, -0.26f, 0), v(x + 0.025f, -0.21f, 0.92f), 0.2f, METAL, seed, where);
        add_block(s, v(x - 0.025f, 0.2f, 0), v(x + 0.025f, 0.25f, 0.62f), 0.2f, METAL, seed, where);
        add_block(s, v(x - 0.03f, -0.26f, 0.60f), v(x + 0.03f, 0.27f, 0.63f), 0.2f, METAL, seed, where);
        add_block(s, v(x - 0.02f, -0.22f, 0.36f), v(x + 0.02f, 0.23f, 0.41f), 0.2f, METAL, seed, where);
    }
}

static void add_street_lamp(world* s, float height, place where) {
    static const float foot[] = {7, 1, 0, 1, 0.1f, 0.6f, 0.18f, 0.55f, 0.6f, 0.7f, 0.65f, 0.35f, 0.75f, 0.3f, 1.0f};
    const uint32_t seed = draw_seed(s);
    add_lathe(s, foot, 0.14f, 0.9f, 20, 24, METAL, seed, where);
    add_tube(s, v(0, 0, 0.8f), v(0, 0, height), 0.04f, 0.03f, 10, METAL, seed, where);
    add_tube(s, v(-0.3f, 0, height - 0.25f), v(0.3f, 0, height - 0.25f), 0.015f, 0.015f, 6, METAL, seed, where);
    for (int i = -1; i <= 1; i += 2)
        add_ball(s, 0.12f, GLOW, seed, within(where, 0.3f * (float)i, 0, height - 0.38f, 0));
    add_lathe(s, profiles[7], 0.07f, 0.2f, 14, 12, METAL, seed, within(where, 0, 0, height, 0));
}

static void add_crate(world* s, float x, float y, float z, place where) { // of slats, open above
    const uint32_t seed = draw_seed(s);
    const float t = 0.012f;
    for (int i = 0; i < 3; i++) {
        const float lo = z * (0.04f + 0.34f * (float)i), hi = lo + 0.26f * z;
        add_block(s, v(-x, -y, lo), v(x, -y + t, hi), 0.3f, WOOD, seed, where);
        add_block(s, v(-x, y - t, lo), v(x, y, hi), 0.3f, WOOD, seed, where);
        add_block(s, v(-x, -y, lo), v(-x + t, y, hi), 0.3f, WOOD, seed, where);
        add_block(s, v(x - t, -y, lo), v(x, y, hi), 0.3f, WOOD, seed, where);
    }
    add_sheet(s, v(-x, -y, 0.05f * z), v(2 * x, 0, 0), v(0, 2 * y, 0), 0.3f, WOOD, seed, where);
}

static void add_fruit_crate(world* s, place where) {
    const uint32_t seed = draw_seed(s);
    const int kind = draw_int(s, 3);
    const float step = kind == 2 ? 0.085f : 0.1f;
    add_crate(s, 0.27f, 0.2f, 0.17f, where);
    for (int j = 0; j < 4; j++)
        for (int i = 0; i < 5; i++) {
            const float shape[4] = {0.5f * step, kind == 1 ? 0.93f : 1.25f, 0.05f, (float)(i + 7 * j)},
                        apple[1] = {0.54f * step};
            const place at = within(where, -0.21f + 0.105f * (float)i + draw(s, -0.01f, 0.01f),
                                    -0.14f + 0.094f * (float)j, draw(s, 0.14f, 0.18f), draw(s, 0, 6.0f));
            if (kind == 0) add_patch(s, patch_apple, apple, 16, 12, APPLE, seed + (uint32_t)(5 * j + i), at);
            else
                add_patch(s, patch_sphere, shape, 16, 12, kind == 1 ? ORANGE : ENAMEL,
                          kind == 1 ? seed + (uint32_t)(5 * j + i) : seed, at);
        }
}

#endif // SCENE_OBJECTS_H
