// scene_materials.h - procedural materials: colour, relief and gloss at a point of a surface. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_MATERIALS_H
#define SCENE_MATERIALS_H

#include "scene_noise.h"

typedef enum material {
    PAVING, BRICK, PLASTER, PLANKS, CLOTH, GLAZE, TERRACOTTA, LEAF, APPLE, ORANGE, BALL, BOOK, GRANITE, ROPE, SOIL, COPING
} material;

typedef struct look {
    v3 albedo;    // linear
    float height; // of the relief in metres, for bump mapping
    float gloss;  // 0 matt .. 1 glazed
} look;

static look look_paving(v3 p, float w) {
    look l = {{0, 0, 0}, 0, 0.0f};
    const float wobble = 0.25f * soft_noise(mul(p, 3.0f), 3.0f * w);
    const cell c = voronoi(2.6f * p.x + wobble, 2.6f * p.y - wobble, 3);
    const float joint = 1.0f - step_between(0.03f, 0.11f, c.edge);
    const float grain = fbm(mul(p, 34.0f), 3, 34.0f * w),
                blotch = fbm(add(mul(p, 5.0f), v((float)(c.id & 63u), 0, 0)), 4, 5.0f * w);
    const v3 warm = v(0.50f, 0.42f, 0.33f), cool = v(0.34f, 0.35f, 0.36f), rust = v(0.46f, 0.30f, 0.21f);
    v3 stone = mix(mix(warm, cool, part(c.id, 0)), rust, 0.55f * part(c.id, 1) * part(c.id, 1));
    stone = mul(stone, (0.62f + 0.5f * part(c.id, 2)) * (0.55f + 0.55f * blotch) * (0.6f + 0.8f * grain));
    const float damp = step_between(0.45f, 0.75f, fbm(mul(p, 1.3f), 3, 1.3f * w));
    const v3 moss = mul(mix(v(0.05f, 0.09f, 0.02f), v(0.15f, 0.19f, 0.05f), fbm(mul(p, 60.0f), 2, 60.0f * w)), 1.1f);
    const v3 earth = mul(v(0.13f, 0.10f, 0.07f), 0.5f + grain);
    l.albedo = mix(stone, mix(earth, moss, damp), joint);
    l.height = -0.014f * joint + 0.006f * grain;
    return l;
}

static look look_brick(float s, float z, v3 p, int32_t salt, float w) { // s along the wall
    look l = {{0, 0, 0}, 0, 0.0f};
    const int32_t row = floor_int(z / 0.085f);
    const float along = s / 0.26f + (row & 1 ? 0.5f : 0.0f);
    const int32_t column = floor_int(along);
    const float fx = (along - (float)column) * 0.26f, fz = z - (float)row * 0.085f;
    const float edge =
        minf(minf(fx, 0.26f - fx), minf(fz, 0.085f - fz)) + 0.008f * (soft_noise(mul(p, 30.0f), 30.0f * w) - 0.5f);
    const float mortar = 1.0f - step_between(0.006f, 0.013f, edge);
    const uint32_t id = hash3(row, column, salt);
    v3 clay = mix(v(0.42f, 0.16f, 0.09f), v(0.54f, 0.29f, 0.16f), part(id, 0));
    if (part(id, 1) > 0.82f) clay = v(0.20f, 0.11f, 0.09f);
    if (part(id, 1) < 0.10f) clay = v(0.58f, 0.42f, 0.28f);
    clay = mul(clay, (0.6f + 0.8f * fbm(mul(p, 28.0f), 3, 28.0f * w)) * (0.75f + 0.45f * part(id, 2)));
    const float grime = step_between(0.35f, 0.8f, fbm(mul(p, 1.7f), 4, 1.7f * w) + 0.35f * (0.5f - z));
    l.albedo = mix(clay, mul(v(0.50f, 0.47f, 0.42f), 0.7f + 0.4f * soft_noise(mul(p, 45.0f), 45.0f * w)), mortar);
    l.albedo = times(l.albedo, mix(v(1, 1, 1), v(0.45f, 0.47f, 0.38f), 0.8f * grime));
    l.height = -0.008f * mortar;
    return l;
}

static look look_plaster(float s, float z, v3 p, float w) { // old ochre plaster over bricks, with ivy
    look l = {{0, 0, 0}, 0, 0.0f};
    const float stain = fbm(v(2.2f * s, 2.0f * p.x, 0.7f * z), 4, 2.2f * w), fine = fbm(mul(p, 22.0f), 3, 22.0f * w);
    l.albedo =
        mul(mix(v(0.66f, 0.50f, 0.30f), v(0.52f, 0.42f, 0.31f), stain), (0.55f + 0.6f * stain) * (0.8f + 0.4f * fine));
    const cell crack = voronoi(2.1f * s + 0.5f * stain, 2.1f * z + 0.5f * fine, 11);
    if (crack.edge < 0.02f) l.albedo = mul(l.albedo, 0.45f);
    if (fbm(add(mul(p, 1.4f), v(40, 0, 0)), 4, 1.4f * w) + 0.12f * (0.8f - z) > 0.57f) l = look_brick(s, z, p, 29, w);
    const cell leaf = voronoi(11.0f * s, 11.0f * z, 21);
    const float cover = fbm(add(mul(p, 0.9f), v(7, 3, 1)), 3, 0.9f * w) + 0.06f * (z - 1.0f);
    if (cover + 0.16f * (part(leaf.id, 0) - 0.5f) > 0.55f && leaf.edge > 0.07f) {
        l.albedo = mul(mix(v(0.06f, 0.14f, 0.03f), v(0.22f, 0.30f, 0.07f), part(leaf.id, 1)), 0.5f + 1.1f * leaf.edge);
        if (part(leaf.id, 2) > 0.88f) l.albedo = v(0.42f, 0.13f, 0.05f);
        l.height = 0.05f * minf(leaf.edge, 0.4f);
    }
    return l;
}

static look look_planks(v3 p, uint32_t seed, float w) { // boards along x, 13 cm wide
    look l = {{0, 0, 0}, 0, 0.12f};
    const int32_t board = floor_int(p.y / 0.13f + 100.0f) + (int32_t)(seed * 31u) + floor_int(p.z * 3.0f) * 7;
    const float across = p.y / 0.13f + 100.0f - floorf(p.y / 0.13f + 100.0f);
    const float shade = random3(board, 1, 5), shift = 10.0f * random3(board, 2, 5);
    const float grain = fbm(v(2.5f * p.x + shift, 38.0f * p.y, 38.0f * p.z + shift), 4, 38.0f * w);
    const float rings =
        0.5f + 0.5f * sinf(55.0f * (p.y + 0.10f * fbm(v(1.6f * p.x + shift, 3.0f * p.y, p.z), 3, 3.0f * w) + shift));
    const v3 dark = v(0.17f, 0.09f, 0.045f), light = v(0.55f, 0.36f, 0.19f);
    l.albedo = mul(mix(dark, light, clampf(2.1f * grain - 0.75f + 0.45f * rings, 0, 1)), 0.65f + 0.6f * shade);
    const float gap = minf(across, 1.0f - across);
    if (gap < 0.035f) l.albedo = mul(l.albedo, 0.18f);
    const cell knot = voronoi(2.4f * p.x + shift, 7.0f * p.y, 51);
    if (part(knot.id, 0) > 0.6f && knot.edge > 0.55f) l.albedo = mul(l.albedo, 0.35f);
    l.height = 0.002f * grain - (gap < 0.035f ? 0.004f : 0.0f);
    return l;
}

static look look_cloth(v3 p, float w) { // gingham with a woven border
    look l = {{0, 0, 0}, 0, 0.0f};
    const int a = floor_int(p.x / 0.055f) & 1, b = floor_int(p.y / 0.055f) & 1;
    const v3 white = v(0.80f, 0.77f, 0.70f), red = v(0.52f, 0.05f, 0.06f), pink = v(0.66f, 0.30f, 0.27f);
    l.albedo = a && b ? red : a || b ? pink : white;
    if (fabsf(p.y) > 0.225f)
        l.albedo =
            floor_int(p.x / 0.02f + (p.y > 0 ? p.y : -p.y) * 50.0f) & 1 ? v(0.75f, 0.7f, 0.6f) : v(0.07f, 0.12f, 0.3f);
    const float weave = 0.5f + (w < 0.002f ? 0.25f * (sinf(p.x * 1500.0f) + sinf(p.y * 1500.0f)) : 0.0f);
    l.albedo = mul(l.albedo, 0.72f + 0.2f * weave + 0.25f * fbm(mul(p, 14.0f), 3, 14.0f * w));
    return l;
}

static look look_glaze(v3 p, float w) { // white porcelain, blue bands and flowers
    look l = {{0, 0, 0}, 0, 0.9f};
    const float angle = atan2f(p.y, p.x), z = p.z;
    const v3 white = v(0.78f, 0.77f, 0.73f), blue = v(0.03f, 0.07f, 0.32f), gold = v(0.55f, 0.36f, 0.08f);
    float ink = 0.0f;
    ink = maxf(ink, step_between(0.006f, 0.002f, fabsf(z - 0.06f - 0.006f * sinf(16.0f * angle))));
    ink = maxf(ink, step_between(0.010f, 0.006f, fabsf(z - 0.335f)));
    const float u = 7.0f * angle / 6.2831853f, up = (z - 0.19f) / 0.085f;
    const float fu = (u - floorf(u) - 0.5f) * 2.0f, radius = sqrtf(fu * fu + up * up), turn = atan2f(up, fu);
    ink = maxf(ink, step_between(0.08f, 0.0f, radius - 0.42f - 0.3f * fabsf(sinf(2.5f * turn))) *
                        step_between(0.12f, 0.2f, radius));
    ink = maxf(ink, step_between(0.62f, 0.68f, noise(v(9.0f * u, 60.0f * z, 3.0f))) *
                        step_between(1.05f, 1.3f, fabsf(up)) * (z < 0.3f && z > 0.075f));
    l.albedo = mix(white, blue, ink * (0.7f + 0.3f * soft_noise(mul(p, 60.0f), 60.0f * w)));
    if (fabsf(z - 0.36f) < 0.006f || fabsf(z - 0.035f) < 0.005f) l.albedo = gold;
    return l;
}

static look look_ball(v3 p, float radius, float w) {
    look l = {{0, 0, 0}, 0, 0.35f};
    static const v3 colors[6] = {{0.62f, 0.04f, 0.04f}, {0.75f, 0.73f, 0.68f}, {0.04f, 0.16f, 0.50f},
                                 {0.75f, 0.73f, 0.68f}, {0.78f, 0.52f, 0.04f}, {0.05f, 0.36f, 0.14f}};
    const v3 q = v(p.x, 0.8f * p.y - 0.6f * p.z, 0.6f * p.y + 0.8f * p.z); // poles tilted
    const int sector = floor_int((atan2f(q.y, q.x) / 6.2831853f + 0.5f) * 5.9999f);
    l.albedo = fabsf(q.z) > 0.93f * radius ? colors[1] : colors[sector];
    l.albedo = mul(l.albedo, 0.7f + 0.45f * fbm(mul(p, 25.0f), 4, 25.0f * w));
    if (fbm(add(mul(p, 11.0f), v(3, 8, 1)), 4, 11.0f * w) > 0.63f)
        l.albedo = mix(l.albedo, v(0.25f, 0.19f, 0.13f), 0.6f);  // dirt
    return l;
}

static look look_book(v3 p, v3 n, uint32_t seed, float w) { // lies flat: pages at the sides, a printed cover
    static const v3 covers[5] = {{0.45f, 0.07f, 0.06f}, {0.05f, 0.16f, 0.30f}, {0.09f, 0.25f, 0.13f}, {0.60f, 0.44f, 0.14f},
                                 {0.30f, 0.11f, 0.28f}};
    look l = {{0, 0, 0}, 0, 0.15f};
    const v3 cover = covers[seed % 5u];
    l.albedo = cover;
    if (fabsf(n.z) < 0.5f && n.x > -0.5f) { // not the spine
        l.albedo = mul(v(0.72f, 0.66f, 0.52f), 0.6f + 0.5f * random3(floor_int(p.z * 700.0f), 3, (int32_t)seed));
    } else {
        const float x = p.x / 0.10f, y = p.y / 0.15f; // about -1..1 on the cover
        const v3 light = v(0.75f, 0.70f, 0.56f);
        if (fabsf(maxf(fabsf(x), fabsf(y)) - 0.86f) < 0.035f) l.albedo = light;
        if (fabsf(y - 0.45f) < 0.16f && fabsf(x) < 0.62f &&
            random3(floor_int(x * 14.0f), floor_int(y * 9.0f), (int32_t)seed) > 0.42f)
            l.albedo = light;
        if (x * x + (y + 0.3f) * (y + 0.3f) < 0.13f) l.albedo = mix(light, cover, soft_noise(mul(p, 70.0f), 70.0f * w));
        l.albedo = mul(l.albedo, 0.7f + 0.5f * fbm(mul(p, 40.0f), 3, 40.0f * w));
    }
    return l;
}

static look look_fruit(material m, v3 p, uint32_t seed, float w) {
    look l = {{0, 0, 0}, 0, 0.45f};
    const float fine = fbm(mul(p, 160.0f), 2, 160.0f * w),
                spots = soft_noise(add(mul(p, 240.0f), v((float)seed, 0, 0)), 240.0f * w);
    if (m == ORANGE) {
        l.albedo = mul(mix(v(0.80f, 0.30f, 0.02f), v(0.85f, 0.44f, 0.05f), fine), 0.8f + 0.3f * spots);
        l.height = 0.0012f * spots;
    } else {
        const float streak = fbm(v(14.0f * atan2f(p.y, p.x), 12.0f * p.z, (float)seed), 3, 40.0f * w);
        const float blush = step_between(0.35f, 0.65f, fbm(add(mul(p, 12.0f), v((float)seed, 1, 2)), 2, 12.0f * w));
        l.albedo = mix(v(0.56f, 0.50f, 0.10f), v(0.50f, 0.04f, 0.03f), clampf(1.2f * blush * (0.4f + streak), 0, 1));
        if (spots > 0.86f) l.albedo = mix(l.albedo, v(0.7f, 0.6f, 0.3f), 0.6f);
    }
    return l;
}

// Appearance of a material at point `p` with normal `n`, both in the object's axes. `seed` distinguishes objects; w: width
// of a pixel.
static look look_at(material m, v3 p, v3 n, uint32_t seed, float w) {
    look l = {{0.5f, 0.5f, 0.5f}, 0.0f, 0.0f};
    switch (m) {
        case PAVING: return look_paving(p, w);
        case BRICK: return look_brick(fabsf(n.x) > 0.5f ? p.y : p.x, p.z, p, 7, w);
        case PLASTER: return look_plaster(fabsf(n.x) > 0.5f ? p.y : p.x, p.z, p, w);
        case PLANKS: return look_planks(p, seed, w);
        case CLOTH: return look_cloth(p, w);
        case GLAZE: return look_glaze(p, w);
        case APPLE: case ORANGE: return look_fruit(m, p, seed, w);
        case BALL: return look_ball(p, 0.26f, w);
        case BOOK: return look_book(p, n, seed, w);
        case TERRACOTTA: {
            const float bands = 0.5f + 0.5f * sinf(p.z * 130.0f),
                        chalk = step_between(0.5f, 0.7f, fbm(mul(p, 7.0f), 4, 7.0f * w));
            l.albedo = mix(mul(v(0.55f, 0.22f, 0.11f), 0.55f + 0.7f * fbm(mul(p, 26.0f), 3, 26.0f * w)),
                           v(0.62f, 0.54f, 0.46f), 0.6f * chalk);
            if (fabsf(p.z - 0.24f) < 0.035f) // a pressed zigzag
                l.albedo =
                    mul(l.albedo, fabsf(fmodf(fabsf(atan2f(p.y, p.x)) * 6.0f, 1.0f) - 0.5f) * 0.1f > fabsf(p.z - 0.24f)
                                      ? 0.45f
                                      : 1.1f);
            l.height = 0.003f * bands;
            return l;
        }
        case LEAF: {
            const float hue = random3((int32_t)seed, 5, 8), vein = fabsf(p.y) < 0.004f ? 1.35f : 1.0f;
            l.albedo = mul(mix(v(0.07f, 0.17f, 0.03f), v(0.27f, 0.36f, 0.07f), hue),
                           vein * (0.75f + 0.5f * soft_noise(mul(p, 90.0f), 90.0f * w)));
            if (hue > 0.93f) l.albedo = v(0.62f, 0.10f, 0.16f); // a flower
            l.gloss = 0.15f;
            return l;
        }
        case GRANITE: {
            const float grain = fbm(mul(p, 38.0f), 3, 38.0f * w), big = fbm(mul(p, 9.0f), 3, 9.0f * w);
            l.albedo = mul(mix(v(0.22f, 0.21f, 0.20f), v(0.62f, 0.58f, 0.53f), big), 0.45f + 1.0f * grain);
            if (fbm(add(mul(p, 6.0f), v(9, 9, 9)), 4, 6.0f * w) > 0.58f)
                l.albedo = mix(l.albedo, v(0.30f, 0.31f, 0.08f), 0.7f);  // lichen
            l.height = 0.01f * big + 0.004f * grain;
            return l;
        }
        case ROPE: {
            const float ring = atan2f(p.y, p.x), around = atan2f(p.z, sqrtf(p.x * p.x + p.y * p.y) - 0.17f);
            const float strand = 0.5f + 0.5f * sinf(26.0f * ring + 3.0f * around);
            l.albedo = mul(mix(v(0.30f, 0.17f, 0.07f), v(0.74f, 0.55f, 0.30f), strand),
                           0.6f + 0.8f * fbm(v(50.0f * ring, 5.0f * around, 0), 3, 200.0f * w));
            l.height = 0.008f * strand;
            return l;
        }
        case SOIL: l.albedo = mul(v(0.10f, 0.07f, 0.045f), 0.4f + 1.3f * fbm(mul(p, 50.0f), 3, 50.0f * w)); return l;
        case COPING: l.albedo = mul(v(0.46f, 0.43f, 0.39f), 0.4f + 1.1f * fbm(mul(p, 9.0f), 5, 9.0f * w)); return l;
    }
    return l;
}

#endif // SCENE_MATERIALS_H
