// scene_materials.h - procedural materials: colour, relief and gloss at a point of a surface. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_MATERIALS_H
#define SCENE_MATERIALS_H

#include "scene_noise.h"
#include "scene_text.h"

typedef enum material {
    // of the courtyard
    PAVING,
    BRICK,
    PLASTER,
    PLANKS,
    CLOTH,
    GLAZE,
    TERRACOTTA,
    LEAF,
    APPLE,
    ORANGE,
    BALL,
    BOOK,
    GRANITE,
    ROPE,
    SOIL,
    COPING,
    // of the family
    WALL,
    WALLPAPER,
    CLAY_BRICK,
    ASHLAR,
    CONCRETE,
    ASPHALT,
    GRAVEL,
    GRASS,
    TILES,
    PARQUET,
    ROOF,
    MARBLE,
    WOOD,
    BARK,
    FABRIC,
    ENAMEL,
    METAL,
    CHROME,
    MIRROR,
    GLASSY,
    FOLIAGE,
    PETAL,
    LEAVES,
    LABEL,
    PAGES,
    GLOW,
    // panels, see look_panel
    PICTURE,
    POSTER,
    SIGN,
    SPINE,
    WINDOW,
    SHUTTER,
    DOOR,
    CHALK,
    RUG
} material;

// `seed` distinguishes objects of the same material, `yaw` turns the object's axes into the scene's.
typedef struct surface { material m; uint32_t seed; float yaw, aspect; } surface; // aspect: width / height of a panel

typedef struct look {
    v3 albedo;    // linear
    float height; // of the relief in metres, for bump mapping
    float gloss; // 0 matt .. 1 glazed
    float mirror; // reflectance of a mirror
    v3 glow;      // emitted light
} look;

static look blank(float gloss) {
    const look l = {{0, 0, 0}, 0, gloss, 0, {0, 0, 0}};
    return l;
}

static look look_paving(v3 p, float w) {
    look l = blank(0.0f);
    const float wobble = 0.25f * soft_noise(mul(p, 3.0f), 3.0f * w);
    const voronoi_cell c = voronoi(2.6f * p.x + wobble, 2.6f * p.y - wobble, 3);
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
    look l = blank(0.0f);
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
    look l = blank(0.0f);
    const float stain = fbm(v(2.2f * s, 2.0f * p.x, 0.7f * z), 4, 2.2f * w), fine = fbm(mul(p, 22.0f), 3, 22.0f * w);
    l.albedo =
        mul(mix(v(0.66f, 0.50f, 0.30f), v(0.52f, 0.42f, 0.31f), stain), (0.55f + 0.6f * stain) * (0.8f + 0.4f * fine));
    const voronoi_cell crack = voronoi(2.1f * s + 0.5f * stain, 2.1f * z + 0.5f * fine, 11);
    if (crack.edge < 0.02f) l.albedo = mul(l.albedo, 0.45f);
    if (fbm(add(mul(p, 1.4f), v(40, 0, 0)), 4, 1.4f * w) + 0.12f * (0.8f - z) > 0.57f) l = look_brick(s, z, p, 29, w);
    const voronoi_cell leaf = voronoi(11.0f * s, 11.0f * z, 21);
    const float cover = fbm(add(mul(p, 0.9f), v(7, 3, 1)), 3, 0.9f * w) + 0.06f * (z - 1.0f);
    if (cover + 0.16f * (part(leaf.id, 0) - 0.5f) > 0.55f && leaf.edge > 0.07f) {
        l.albedo = mul(mix(v(0.06f, 0.14f, 0.03f), v(0.22f, 0.30f, 0.07f), part(leaf.id, 1)), 0.5f + 1.1f * leaf.edge);
        if (part(leaf.id, 2) > 0.88f) l.albedo = v(0.42f, 0.13f, 0.05f);
        l.height = 0.05f * minf(leaf.edge, 0.4f);
    }
    return l;
}

static look look_planks(v3 p, uint32_t seed, float w) { // boards along x, 13 cm wide
    look l = blank(0.12f);
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
    const voronoi_cell knot = voronoi(2.4f * p.x + shift, 7.0f * p.y, 51);
    if (part(knot.id, 0) > 0.6f && knot.edge > 0.55f) l.albedo = mul(l.albedo, 0.35f);
    l.height = 0.002f * grain - (gap < 0.035f ? 0.004f : 0.0f);
    return l;
}

static look look_cloth(v3 p, float w) { // gingham with a woven border
    look l = blank(0.0f);
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
    look l = blank(0.9f);
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
    look l = blank(0.35f);
    static const v3 colors[6] = {{0.62f, 0.04f, 0.04f}, {0.75f, 0.73f, 0.68f}, {0.04f, 0.16f, 0.50f},
                                 {0.75f, 0.73f, 0.68f}, {0.78f, 0.52f, 0.04f}, {0.05f, 0.36f, 0.14f}};
    const v3 q = v(p.x, 0.8f * p.y - 0.6f * p.z, 0.6f * p.y + 0.8f * p.z); // poles tilted
    const int sector = floor_int((atan2f(q.y, q.x) / 6.2831853f + 0.5f) * 5.9999f);
    l.albedo = fabsf(q.z) > 0.93f * radius ? colors[1] : colors[sector];
    l.albedo = mul(l.albedo, 0.7f + 0.45f * fbm(mul(p, 25.0f), 4, 25.0f * w));
    if (fbm(add(mul(p, 11.0f), v(3, 8, 1)), 4, 11.0f * w) > 0.63f)
        l.albedo = mix(l.albedo, v(0.25f, 0.19f, 0.13f), 0.6f); // dirt
    return l;
}

static look look_book(v3 p, v3 n, uint32_t seed, float w) { // lies flat: pages at the sides, a printed cover
    static const v3 covers[5] = {{0.45f, 0.07f, 0.06f},
                                 {0.05f, 0.16f, 0.30f},
                                 {0.09f, 0.25f, 0.13f},
                                 {0.60f, 0.44f, 0.14f},
                                 {0.30f, 0.11f, 0.28f}};
    look l = blank(0.15f);
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
    look l = blank(0.45f);
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

// ---- materials of the family's scenes -------------------------------------------
// `seed` chooses colours and patterns.

enum { PAINTS = 20, WHITE = 1 << 24 }; // a seed of WHITE: white paint
static v3 paint_of(uint32_t seed, int which) { // one of a box of paints that go together
    static const v3 box[PAINTS] = {
        {0.52f, 0.06f, 0.05f}, {0.70f, 0.22f, 0.07f}, {0.76f, 0.48f, 0.08f}, {0.70f, 0.62f, 0.36f},
        {0.30f, 0.38f, 0.10f}, {0.08f, 0.26f, 0.12f}, {0.05f, 0.28f, 0.27f}, {0.08f, 0.24f, 0.46f},
        {0.05f, 0.09f, 0.28f}, {0.26f, 0.10f, 0.30f}, {0.50f, 0.16f, 0.26f}, {0.72f, 0.42f, 0.38f},
        {0.74f, 0.70f, 0.62f}, {0.62f, 0.66f, 0.64f}, {0.34f, 0.35f, 0.36f}, {0.10f, 0.10f, 0.11f},
        {0.36f, 0.20f, 0.10f}, {0.56f, 0.40f, 0.24f}, {0.36f, 0.50f, 0.56f}, {0.52f, 0.56f, 0.30f}};
    return seed == WHITE ? v(0.66f, 0.64f, 0.59f) : box[hash3((int32_t)seed, which, 71) % PAINTS];
}
static v3 pale(v3 color, float amount) { return mix(color, v(0.72f, 0.69f, 0.63f), amount); }

typedef struct flat { float x, y; } flat;

// Coordinates along a surface: the axes of the plane that the normal is closest to.
static flat flatten(v3 p, v3 n) {
    const float x = fabsf(n.x), y = fabsf(n.y), z = fabsf(n.z);
    const flat f = {z > maxf(x, y) ? p.x : x > y ? p.y : p.x, z > maxf(x, y) ? p.y : p.z};
    return f;
}

static look look_wall(v3 p, v3 n, uint32_t seed, float w) { // painted plaster, rubbed and stained
    look l = blank(0.0f);
    const flat f = flatten(p, n);
    const float stain = fbm(add(mul(p, 1.1f), v((float)(seed & 31u), 2, 4)), 4, 1.1f * w);
    const float fine = fbm(mul(p, 21.0f), 3, 21.0f * w);
    l.albedo = mul(pale(paint_of(seed, 1), 0.45f), (0.72f + 0.5f * stain) * (0.82f + 0.36f * fine));
    if (seed & 1u && f.y < 0.9f + 0.02f * stain) // another colour below
        l.albedo = mul(pale(paint_of(seed, 2), 0.25f), (0.72f + 0.5f * stain) * (0.82f + 0.36f * fine));
    const voronoi_cell crack = voronoi(1.3f * f.x + 0.6f * stain, 1.3f * f.y + 0.4f * fine, (int32_t)(seed & 255u));
    if (crack.edge < 0.012f && stain > 0.5f) l.albedo = mul(l.albedo, 0.55f);
    const float peeled = fbm(add(mul(p, 2.3f), v(4, 9, (float)(seed & 15u))), 4, 2.3f * w);
    if (peeled > 0.66f) l.albedo = mul(v(0.48f, 0.45f, 0.40f), 0.6f + 0.7f * fine);
    l.height = peeled > 0.66f ? -0.004f : 0.002f * fine;
    return l;
}

static look look_wallpaper(v3 p, v3 n, uint32_t seed, float w) {
    look l = blank(0.0f);
    const flat f = flatten(p, n);
    const v3 ground = pale(paint_of(seed, 1), 0.6f), ink = pale(paint_of(seed, 2), 0.15f), extra = paint_of(seed, 3);
    const float step = 0.14f + 0.05f * (float)(seed % 4u), x = f.x / step, y = f.y / step;
    const int32_t row = floor_int(y);
    const float fx = x + 0.5f * (float)(row & 1) - floorf(x + 0.5f * (float)(row & 1)) - 0.5f,
                fy = y - (float)row - 0.5f;
    const float r = sqrtf(fx * fx + fy * fy), turn = atan2f(fy, fx), soft = 0.02f + w / step;
    float a = 0.0f, b = 0.0f;
    switch (seed / 4u % 3u) {
        case 0: // blossoms
            a = step_between(soft, -soft, r - 0.26f - 0.1f * sinf(5.0f * turn));
            b = step_between(soft, -soft, r - 0.1f);
            break;
        case 1: // stripes with dots
            a = step_between(-soft, soft, fabsf(x - floorf(x) - 0.5f) - 0.28f);
            b = step_between(soft, -soft, r - 0.12f);
            break;
        default: // trellis
            a = step_between(soft, -soft, fabsf(fabsf(fx) + fabsf(fy) - 0.42f) - 0.045f);
            b = step_between(soft, -soft, fabsf(r - 0.2f) - 0.04f);
    }
    l.albedo = mul(mix(mix(ground, ink, 0.9f * a), extra, 0.8f * b), 0.8f + 0.35f * fbm(mul(p, 9.0f), 4, 9.0f * w));
    return l;
}

static look look_tiles(v3 p, v3 n, uint32_t seed, float w) {
    look l = blank(0.62f);
    const flat f = flatten(p, n);
    const float size = 0.10f + 0.05f * (float)(seed % 5u), x = f.x / size, y = f.y / size;
    const int32_t i = floor_int(x), j = floor_int(y);
    const float fx = x - (float)i, fy = y - (float)j, edge = size * minf(minf(fx, 1 - fx), minf(fy, 1 - fy));
    const uint32_t id = hash3(i, j, (int32_t)(seed & 1023u));
    const v3 light = pale(paint_of(seed, 1), 0.75f), dark = paint_of(seed, 2);
    const float soft = 0.02f + w / size, r = sqrtf((fx - 0.5f) * (fx - 0.5f) + (fy - 0.5f) * (fy - 0.5f));
    float ink = 0.0f;
    switch (seed / 8u % 4u) {
        case 0: ink = (float)((i + j) & 1); break;
        case 1: ink = hash3(i, j, 7) % 7u == 0 ? 1.0f : 0.0f; break;
        case 2: { // quarter circles that meet across tiles
            const float cx = fx < 0.5f ? fx : 1 - fx, cy = fy < 0.5f ? fy : 1 - fy, c = sqrtf(cx * cx + cy * cy);
            ink = maxf(step_between(soft, -soft, fabsf(c - 0.38f) - 0.07f), step_between(soft, -soft, r - 0.13f));
            break;
        }
        default: // stars
            ink = step_between(soft, -soft, fabsf(fx - 0.5f) + fabsf(fy - 0.5f) - 0.36f);
            ink = maxf(ink, step_between(soft, -soft, maxf(fabsf(fx - 0.5f), fabsf(fy - 0.5f)) - 0.26f));
    }
    const float grout = step_between(0.004f, 0.0025f, edge);
    l.albedo = mul(mix(light, dark, 0.92f * ink),
                   (0.84f + 0.22f * part(id, 0)) * (0.85f + 0.3f * fbm(mul(p, 13.0f), 4, 13.0f * w)));
    l.albedo = mix(l.albedo, v(0.30f, 0.28f, 0.25f), grout * minf(1.0f, 0.005f / maxf(w, 1e-6f)));
    l.gloss *= 1.0f - grout;
    l.height = -0.002f * grout;
    return l;
}

static v3 wood_at(float along, float across, uint32_t id, float w, uint32_t seed) {
    static const v3 kinds[5][2] = {{{0.16f, 0.08f, 0.04f}, {0.46f, 0.27f, 0.13f}},
                                   {{0.34f, 0.22f, 0.11f}, {0.62f, 0.46f, 0.27f}},
                                   {{0.10f, 0.045f, 0.03f}, {0.28f, 0.13f, 0.08f}},
                                   {{0.30f, 0.27f, 0.23f}, {0.50f, 0.46f, 0.40f}},
                                   {{0.30f, 0.12f, 0.05f}, {0.58f, 0.29f, 0.14f}}};
    const float shift = 20.0f * part(id, 0);
    const float grain = fbm(v(3.0f * along + shift, 45.0f * across, shift), 4, 45.0f * w);
    const float bow = fbm(v(1.5f * along + shift, 4.0f * across, 2.0f), 3, 4.0f * w);
    const float rings = w > 0.03f ? 0.5f : 0.5f + 0.5f * sinf(70.0f * (across + 0.12f * bow) + shift);
    const v3* kind = kinds[seed % 5u];
    return mul(mix(kind[0], kind[1], clampf(1.7f * grain - 0.5f + 0.4f * rings, 0, 1)), 0.72f + 0.5f * part(id, 1));
}

static look look_parquet(v3 p, uint32_t seed, float w) { // herringbone or strips, lacquered
    look l = blank(0.55f);
    const float a = 0.085f, x = p.x / a, y = p.y / a;
    const int32_t i = floor_int(x), j = floor_int(y), n = 5;
    float along, across;
    int32_t start, line;
    if (seed & 8u) {
        line = j, start = floor_int((x + 7.0f * part(hash3(j, 3, 5), 1)) / 14.0f);
        along = x + 7.0f * part(hash3(j, 3, 5), 1) - 14.0f * (float)start, across = y - (float)j;
        along = minf(along, 14.0f - along);
    } else {
        const int32_t m = ((i - j) % (2 * n) + 2 * n) % (2 * n);
        const int level = m < n;
        start = level ? i - m : j - (2 * n - 1 - m), line = level ? j : i;
        along = (level ? x : y) - (float)start, across = level ? y - (float)j : x - (float)i;
        start = 2 * start + level;
        along = minf(along, (float)n - along);
    }
    const uint32_t id = hash3(start, line, (int32_t)(seed & 255u));
    l.albedo = wood_at(along * a + part(id, 2), (across + (float)line) * a, id, w, seed);
    const float gap = a * minf(minf(across, 1.0f - across), along);
    if (gap < 0.0022f) l.albedo = mul(l.albedo, 1.0f - 0.75f * minf(1.0f, 0.004f / maxf(w, 1e-6f)));
    l.height = gap < 0.0022f ? -0.002f : 0.0f;
    return l;
}

static look look_wood(v3 p, v3 n, uint32_t seed, float w) { // furniture: grain along the longer of x and z
    look l = blank(0.22f);
    const flat f = flatten(p, n);
    const int upright = seed >> 8 & 1u && fabsf(n.z) < 0.7f;
    l.albedo = wood_at(upright ? f.y : f.x, upright ? f.x : f.y, hash3((int32_t)seed, 4, 4), w, seed);
    return l;
}

// A seed for a fabric of the given pattern: 0 plaid, 1 stripes, 2 flowers, 3 dots, 4 zigzag.
static uint32_t fabric_of(uint32_t seed, uint32_t pattern) { return seed / 40u * 40u + 8u * pattern + seed % 8u; }

static look look_fabric(v3 p, v3 n, uint32_t seed, float w) {
    look l = blank(0.0f);
    const flat f = flatten(p, n);
    const v3 ground = pale(paint_of(seed, 1), 0.3f), ink = paint_of(seed, 2), extra = paint_of(seed, 3);
    const float step = 0.05f + 0.02f * (float)(seed % 5u), x = f.x / step, y = f.y / step, soft = 0.03f + w / step;
    const float fx = x - floorf(x), fy = y - floorf(y);
    l.albedo = ground;
    switch (seed / 8u % 5u) {
        case 0: // plaid
            l.albedo = mix(l.albedo, ink, 0.45f * (float)(fx < 0.45f) + 0.45f * (float)(fy < 0.45f));
            l.albedo = mix(l.albedo, extra,
                           0.8f * maxf((float)(fabsf(fx - 0.75f) < 0.05f), (float)(fabsf(fy - 0.75f) < 0.05f)));
            break;
        case 1: l.albedo = fx < 0.5f ? ground : fabsf(fx - 0.75f) < 0.06f ? extra : ink; break; // stripes
        case 2: { // flowers
            const voronoi_cell c = voronoi(1.2f * x, 1.2f * y, (int32_t)(seed & 63u));
            const v3 petal = part(c.id, 0) > 0.5f ? ink : extra;
            l.albedo = mix(ground, petal, step_between(0.28f - soft, 0.28f + soft, c.edge));
            l.albedo = mix(l.albedo, v(0.7f, 0.6f, 0.2f), step_between(0.62f - soft, 0.62f + soft, c.edge));
            break;
        }
        case 3: { // dots in rows
            const float gx = x + 0.5f * (float)(floor_int(y) & 1), d = hypotf(gx - floorf(gx) - 0.5f, fy - 0.5f);
            l.albedo = mix(ground, ink, step_between(0.24f + soft, 0.24f - soft, d));
            break;
        }
        default: { // zigzag
            const float zig = y + 0.8f * fabsf(fx - 0.5f);
            l.albedo = floor_int(2.0f * zig) & 1 ? ground : floor_int(zig) % 3 == 0 ? extra : ink;
        }
    }
    const float weave = w < 0.002f ? 0.12f * (sinf(1400.0f * f.x) + sinf(1400.0f * f.y)) : 0.0f;
    l.albedo = mul(l.albedo, 0.78f + weave + 0.4f * (fbm(mul(p, 16.0f), 4, 16.0f * w) - 0.2f));
    return l;
}

static look look_enamel(v3 p, uint32_t seed, float w) { // glossy paint, worn at places
    look l = blank(0.4f);
    const float worn = fbm(add(mul(p, 6.0f), v((float)(seed & 63u), 0, 0)), 4, 6.0f * w);
    l.albedo = mul(paint_of(seed, 1), 0.78f + 0.4f * fbm(mul(p, 30.0f), 3, 30.0f * w));
    if (worn > 0.66f) l.albedo = mul(v(0.24f, 0.19f, 0.15f), 0.6f + worn), l.gloss = 0.1f;
    return l;
}

static look look_metal(v3 p, uint32_t seed, float w) { // dark, with rust
    look l = blank(0.45f);
    const float rust = fbm(add(mul(p, 8.0f), v(1, 2, (float)(seed & 63u))), 4, 8.0f * w);
    l.albedo =
        mul(mix(v(0.05f, 0.055f, 0.06f), paint_of(seed, 1), 0.25f), 0.6f + 0.8f * fbm(mul(p, 55.0f), 2, 55.0f * w));
    if (rust > 0.6f) l.albedo = mul(v(0.30f, 0.13f, 0.05f), 0.5f + rust), l.gloss = 0.05f;
    return l;
}

static look look_ground(material m, v3 p, uint32_t seed, float w) {
    look l = blank(0.0f);
    const float coarse = fbm(mul(p, 1.1f), 4, 1.1f * w), fine = fbm(mul(p, 42.0f), 3, 42.0f * w);
    if (m == GRASS) {
        const float blades = fbm(v(70.0f * p.x, 23.0f * p.y, 9.0f * p.x), 3, 70.0f * w),
                    patch = fbm(mul(p, 5.0f), 5, 5.0f * w);
        l.albedo = mul(mix(v(0.06f, 0.13f, 0.025f), v(0.27f, 0.31f, 0.09f), clampf(3.0f * patch - 1.0f, 0, 1)),
                       0.3f + 1.4f * blades);
        const voronoi_cell daisy = voronoi(3.0f * p.x, 3.0f * p.y, (int32_t)(seed & 63u));
        if (daisy.edge > 0.75f && part(daisy.id, 1) > 0.55f)
            l.albedo = part(daisy.id, 2) > 0.4f ? v(0.8f, 0.8f, 0.75f) : v(0.75f, 0.6f, 0.05f);
        l.height = 0.02f * blades;
    } else if (m == GRAVEL) {
        const voronoi_cell c = voronoi(26.0f * p.x, 26.0f * p.y, 5);
        l.albedo = mul(mix(v(0.26f, 0.23f, 0.20f), v(0.62f, 0.57f, 0.50f), w > 0.06f ? 0.5f : part(c.id, 0)),
                       0.55f + 0.8f * fine);
        l.albedo = mul(l.albedo, w > 0.06f ? 0.8f : 0.45f + 0.8f * step_between(0.0f, 0.3f, c.edge));
        l.height = 0.012f * minf(c.edge, 0.5f);
    } else if (m == ASPHALT) {
        l.albedo = mul(v(0.11f, 0.11f, 0.115f), (0.45f + 1.1f * fine) * (0.6f + 0.8f * coarse));
        const voronoi_cell tar = voronoi(0.45f * p.x + 0.4f * coarse, 0.45f * p.y + 0.3f * fine, 9);
        if (tar.edge < 0.02f) l.albedo = v(0.025f, 0.025f, 0.025f);
        l.height = 0.004f * fine;
    } else { // CONCRETE: slabs
        const float size = 0.6f + 0.2f * (float)(seed % 3u), x = p.x / size, y = p.y / size;
        const float fx = x - floorf(x), fy = y - floorf(y), edge = size * minf(minf(fx, 1 - fx), minf(fy, 1 - fy));
        const uint32_t id = hash3(floor_int(x), floor_int(y), 33);
        l.albedo =
            mul(pale(paint_of(seed, 5), 0.8f), (0.45f + 0.35f * part(id, 0)) * (0.4f + 0.5f * coarse + 0.7f * fine));
        const float gum = soft_noise(mul(p, 11.0f), 11.0f * w);
        if (gum > 0.86f) l.albedo = mul(l.albedo, 0.5f);
        if (edge < 0.008f) l.albedo = mul(l.albedo, 0.4f), l.height = -0.006f;
    }
    return l;
}

static look look_stone(material m, v3 p, v3 n, uint32_t seed, float w) {
    look l = blank(0.0f);
    const flat f = flatten(p, n);
    if (m == MARBLE) {
        const float warp = fbm(mul(p, 2.4f), 5, 2.4f * w),
                    vein = fabsf(sinf(7.0f * (p.x + 0.7f * p.y + 0.5f * p.z) + 11.0f * warp));
        l.albedo =
            mix(pale(paint_of(seed, 1), 0.85f), mul(paint_of(seed, 2), 0.6f), step_between(0.22f, 0.0f, vein) * 0.75f);
        l.albedo = mul(l.albedo, 0.72f + 0.5f * fbm(mul(p, 17.0f), 3, 17.0f * w));
        l.gloss = 0.45f;
    } else if (m == ASHLAR) { // blocks of hewn stone
        const int32_t row = floor_int(f.y / 0.32f);
        const float along = f.x / 0.62f + 0.5f * (float)(row & 1), fx = along - floorf(along),
                    fy = f.y / 0.32f - (float)row;
        const uint32_t id = hash3(floor_int(along), row, (int32_t)(seed & 255u));
        const float edge = minf(0.62f * minf(fx, 1 - fx), 0.32f * minf(fy, 1 - fy)),
                    joint = step_between(0.016f, 0.006f, edge);
        const float grain = fbm(mul(p, 30.0f), 3, 30.0f * w),
                    blotch = fbm(add(mul(p, 3.0f), v((float)(id & 63u), 0, 0)), 4, 3.0f * w);
        l.albedo = mul(pale(mix(paint_of(seed, 1), v(0.55f, 0.46f, 0.33f), 0.6f), 0.4f),
                       (0.6f + 0.4f * part(id, 0)) * (0.3f + 0.7f * blotch + 0.5f * grain));
        l.albedo = mix(l.albedo, v(0.25f, 0.23f, 0.20f), 0.8f * joint);
        l.height = -0.012f * joint + 0.005f * grain;
    } else if (m == ROOF) { // rows of rounded tiles
        const float x = f.x / 0.2f, y = f.y / 0.16f;
        const uint32_t id = hash3(floor_int(x), floor_int(y), 3);
        const float round = fabsf(x - floorf(x) - 0.5f), step = y - floorf(y);
        l.albedo = mul(mix(v(0.45f, 0.17f, 0.09f), v(0.32f, 0.20f, 0.15f), part(id, 0)),
                       (0.4f + 0.6f * step) * (1.15f - 1.2f * round * round * 2.0f));
        l.albedo = mul(l.albedo, 0.55f + 0.9f * fbm(mul(p, 14.0f), 4, 14.0f * w));
    } else { // BARK
        const float turn = 9.0f * atan2f(p.y, p.x), ridge = fbm(v(turn, 3.0f * p.z, (float)(seed & 15u)), 4, 9.0f * w);
        l.albedo = mul(mix(v(0.07f, 0.05f, 0.035f), v(0.36f, 0.29f, 0.22f), clampf(2.4f * ridge - 0.7f, 0, 1)),
                       0.6f + 0.7f * fbm(mul(p, 40.0f), 3, 40.0f * w));
        l.height = 0.03f * ridge;
    }
    return l;
}

static look look_foliage(v3 p, uint32_t seed, float w) { // seed: species << 16 | leaf
    look l = blank(0.12f);
    static const v3 greens[7][2] = {
        {{0.05f, 0.13f, 0.025f}, {0.20f, 0.31f, 0.06f}}, {{0.10f, 0.17f, 0.03f}, {0.38f, 0.40f, 0.09f}},
        {{0.04f, 0.11f, 0.05f}, {0.13f, 0.25f, 0.12f}},  {{0.14f, 0.16f, 0.10f}, {0.33f, 0.37f, 0.24f}},
        {{0.22f, 0.07f, 0.02f}, {0.58f, 0.30f, 0.05f}},  {{0.13f, 0.03f, 0.04f}, {0.32f, 0.08f, 0.08f}},
        {{0.07f, 0.16f, 0.03f}, {0.26f, 0.38f, 0.07f}}};
    const v3* kind = greens[(seed >> 16) % 7u];
    l.albedo =
        mul(mix(kind[0], kind[1], random3((int32_t)seed, 5, 8)), 0.75f + 0.5f * soft_noise(mul(p, 70.0f), 70.0f * w));
    return l;
}

static look look_leaves(v3 p, v3 n, uint32_t seed, float w) { // the inside of a hedge
    look l = blank(0.0f);
    const flat f = flatten(p, n);
    const voronoi_cell c = voronoi(15.0f * f.x, 15.0f * f.y, 9);
    const look leaf = look_foliage(p, (seed & ~65535u) | (c.id & 65535u), w);
    l.albedo = mul(leaf.albedo, (0.25f + 1.3f * minf(c.edge, 0.6f)) * (0.4f + 0.9f * fbm(mul(p, 3.0f), 3, 3.0f * w)));
    l.height = 0.05f * minf(c.edge, 0.5f);
    return l;
}

static look look_label(v3 p, v3 n, uint32_t seed, float w) { // cans, jars and boxes: bands around, a word, small print
    static const char* const goods[] = {"SOAP",  "TEA",  "COCOA", "RICE", "OATS",
                                        "PLUMS", "SALT", "BEANS", "MINT", "HONEY"};
    look l = blank(0.3f);
    const float round = fabsf(n.z) < 0.5f ? atan2f(n.y, n.x) : 0.0f, z = p.z;
    const float x = (round / 1.5707963f - floorf(round / 1.5707963f) - 0.5f) * 0.16f;
    const v3 ground = paint_of(seed, 1), ink = pale(paint_of(seed, 2), 0.7f), band = paint_of(seed, 3);
    l.albedo = z < 0.035f || fabsf(z - 0.13f) < 0.008f ? band : ground;
    const float word = ink_in_box(goods[seed % 10u], x, z - 0.085f, 0.12f, 0.045f, 0.17f, w);
    const float print = fabsf(z - 0.05f) < 0.008f && fabsf(x) < 0.05f &&
                        random3(floor_int(x * 400.0f), floor_int(z * 250.0f), (int32_t)seed) > 0.5f;
    l.albedo = mul(mix(l.albedo, ink, maxf(word, 0.7f * print)), 0.8f + 0.35f * fbm(mul(p, 30.0f), 3, 30.0f * w));
    return l;
}

// ---- panels -----------------------------------------------------------------------
// Flat things with a picture: x from -a/2 to a/2 and y from -1/2 to 1/2 for a panel of aspect ratio a, z its height in
// metres.

static v3 picture_at(float x, float y, float a, uint32_t seed, float w) { // landscape, still life or abstract
    const v3 p = v(x + 3.0f * (float)(seed % 17u), y, 0.3f * (float)(seed % 13u));
    const v3 c0 = paint_of(seed, 1), c1 = paint_of(seed, 2), c2 = paint_of(seed, 3), c3 = paint_of(seed, 4);
    const float stroke = 0.7f + 0.6f * fbm(v(40.0f * x, 11.0f * y, p.z), 3, 40.0f * w);
    v3 c;
    if (seed / 4u % 3u == 0) { // hills under a sky
        c = mix(pale(c0, 0.7f), mix(v(0.35f, 0.5f, 0.7f), c0, 0.3f), clampf(y + 0.5f, 0, 1));
        if (hypotf(x - 0.25f * a, y - 0.27f) < 0.09f) c = v(0.85f, 0.65f, 0.3f);
        for (int k = 0; k < 4; k++) {
            const float ridge = 0.18f - 0.17f * (float)k +
                                0.3f * (fbm(v(3.0f * x + 9.0f * (float)k, (float)seed, 1.0f), 4, 3.0f * w) - 0.5f);
            if (y < ridge) c = mul(mix(pale(c1, 0.5f), c2, 0.33f * (float)k), 1.0f - 0.13f * (float)k);
        }
    } else if (seed / 4u % 3u == 1) { // coloured fields with lines
        const voronoi_cell f = voronoi(4.0f * x, 4.0f * y, (int32_t)(seed & 511u));
        const v3 fields[4] = {c0, c1, pale(c2, 0.5f), c3};
        c = f.edge < 0.06f ? v(0.05f, 0.05f, 0.06f) : fields[f.id & 3u];
    } else { // discs and bars
        c = pale(c0, 0.55f);
        for (int k = 0; k < 7; k++) {
            const uint32_t id = hash3((int32_t)seed, k, 91);
            const float dx = x - a * (part(id, 0) - 0.5f) * 0.8f, dy = y - (part(id, 1) - 0.5f) * 0.8f,
                        r = 0.06f + 0.16f * part(id, 2);
            const int inside = id & 1u ? dx * dx + dy * dy < r * r : fabsf(dx) < 0.4f * r && fabsf(dy) < 1.6f * r;
            if (inside) c = paint_of(seed + (uint32_t)k, 6);
        }
    }
    return mul(c, stroke);
}

static v3 small_print(float x, float y, float line, v3 paper, v3 ink, uint32_t seed,
                      float w) { // lines of text too small to read
    const int32_t row = floor_int(y / line);
    const float within = y / line - (float)row, word = x / (0.9f * line);
    const int32_t at = floor_int(word);
    const float there = within > 0.25f && within < 0.75f && random3(row, at / 5, (int32_t)seed) > 0.14f && at % 5 != 4
                            ? 0.3f + 0.6f * random3(row, at, 7)
                            : 0.0f;
    return mix(paper, ink, w > line ? 0.25f : there);
}

static look look_panel(const surface* what, v3 p, float w) {
    static const char* const shops[] = {"BAKERY", "BOOKS", "CAFE 21", "HOTEL", "FLORIST", "TAILOR", "CINEMA", "RECORDS",
                                        "PHARMACY", "OPTICS", "MARKET", "TEA ROOM", "CLOCKS", "BICYCLES"};
    static const char* const titles[] = {"ATLAS", "POEMS", "VOL 7",  "GEOMETRY", "OCEANS",  "HISTORY",
                                         "BIRDS", "CHESS", "OPTICS", "TRAVELS",  "COOKING", "MYTHS",
                                         "STARS", "ALPS",  "MUSIC",  "TREES"};
    static const char* const events[] = {"JAZZ", "OPERA", "CIRCUS", "FAIR", "DANCE", "EXPO 58", "SAIL", "RALLY"};
    look l = blank(0.0f);
    const uint32_t seed = what->seed;
    const float x = p.x, y = p.y, a = what->aspect, rim = minf(0.5f * a - fabsf(x), 0.5f - fabsf(y)),
                px = w / maxf(p.z, 0.01f);
    const v3 c1 = paint_of(seed, 1), c2 = paint_of(seed, 2), c3 = paint_of(seed, 3);
    switch (what->m) {
        case PICTURE: // in a frame
            if (rim < 0.035f) {
                l.albedo = mul(seed & 1u ? v(0.42f, 0.27f, 0.08f) : v(0.08f, 0.06f, 0.05f), 0.6f + 20.0f * rim);
                l.gloss = 0.4f;
            } else if (rim < 0.09f) {
                l.albedo = v(0.66f, 0.64f, 0.58f);
            } else {
                l.albedo = picture_at(x, y, a, seed, px);
            }
            return l;
        case POSTER: {
            const v3 paper = pale(c1, seed & 2u ? 0.75f : 0.1f), ink = seed & 2u ? c2 : pale(c2, 0.8f);
            l.albedo = paper;
            if (y > -0.18f && y < 0.22f && rim > 0.05f)
                l.albedo = picture_at(1.7f * x, 1.7f * (y - 0.02f), a, seed + 5u, px);
            if (y < -0.30f && rim > 0.06f) l.albedo = small_print(x, y, 0.035f, paper, ink, seed, px);
            const float word = ink_in_box(events[seed % 8u], x, y - 0.35f, 0.8f * a, 0.17f, 0.2f, px);
            const float year = ink_in_box(titles[seed / 8u % 16u], x, y + 0.245f, 0.6f * a, 0.06f, 0.15f, px);
            l.albedo =
                mul(mix(l.albedo, ink, maxf(word, year)), 0.85f + 0.3f * fbm(v(8.0f * x, 8.0f * y, 0), 4, 8.0f * px));
            return l;
        }
        case SIGN: {
            const v3 ground = seed & 1u ? mul(c1, 0.5f) : pale(c1, 0.7f),
                     ink = seed & 1u ? pale(c2, 0.85f) : mul(c2, 0.35f);
            l.albedo = fabsf(rim - 0.07f) < 0.018f ? ink : ground;
            l.albedo = mix(l.albedo, ink, ink_in_box(shops[seed % 14u], x, y, 0.8f * a, 0.56f, 0.19f, px));
            l.albedo = mul(l.albedo, 0.75f + 0.45f * fbm(v(5.0f * x, 9.0f * y, (float)(seed & 7u)), 4, 9.0f * px));
            l.gloss = 0.2f;
            return l;
        }
        case SPINE: { // of a book: the title runs downwards
            const float up = 0.5f - fabsf(y);
            l.albedo = mul(c1, 0.75f + 0.4f * fbm(v(30.0f * x, 30.0f * y, (float)(seed & 63u)), 3, 30.0f * px));
            if (fabsf(up - 0.10f) < 0.008f || (seed & 4u && fabsf(up - 0.13f) < 0.008f))
                l.albedo = v(0.60f, 0.45f, 0.16f);
            if (seed & 8u && up < 0.07f) l.albedo = mul(c2, 0.8f);
            const float word = ink_in_box(titles[seed / 16u % 16u], -y - 0.02f, x, 0.62f, 0.55f * a, 0.17f, px);
            l.albedo = mix(l.albedo, seed & 1u ? v(0.66f, 0.52f, 0.20f) : v(0.75f, 0.73f, 0.68f), word);
            l.gloss = seed & 2u ? 0.25f : 0.05f;
            return l;
        }
        case WINDOW: { // panes in a painted frame, curtains behind
            const int columns = 2 + (int)(seed >> 4 & 1u), rows = 2 + (int)(seed >> 5 & 1u);
            const float fx = (x / a + 0.5f) * (float)columns, fy = (y + 0.5f) * (float)rows;
            const float bar = minf(a / (float)columns * (0.5f - fabsf(fx - floorf(fx) - 0.5f)),
                                   (0.5f - fabsf(fy - floorf(fy) - 0.5f)) / (float)rows);
            if (rim < 0.06f || bar < 0.016f) {
                l.albedo = mul(pale(c1, 0.5f), 0.75f + 0.4f * fbm(v(20.0f * x, 20.0f * y, 1.0f), 3, 20.0f * px));
                return l;
            }
            const float open = 0.10f * a * (1.0f + part(seed, 0)), fold = 0.6f + 0.4f * sinf(70.0f * x + 4.0f * y);
            l.albedo =
                mul(v(0.030f, 0.035f, 0.045f), 0.5f + fbm(v(4.0f * x, 4.0f * y, (float)(seed & 31u)), 3, 4.0f * px));
            if (fabsf(x) > open + 0.05f * sinf(5.0f * y) && seed & 64u) l.albedo = mul(pale(c2, 0.6f), 0.35f * fold);
            l.gloss = 1.0f;
            l.mirror = 0.12f;
            return l;
        }
        case SHUTTER: { // slats
            const float slat = y * 22.0f - floorf(y * 22.0f);
            l.albedo = mul(pale(c1, 0.15f), rim < 0.04f ? 0.95f : 0.45f + 0.7f * slat);
            l.albedo = mul(l.albedo, 0.7f + 0.5f * fbm(v(9.0f * x, 30.0f * y, (float)(seed & 7u)), 4, 30.0f * px));
            return l;
        }
        case DOOR: { // four inset fields, a handle
            const float dx = fabsf(fabsf(x) - 0.22f * a), dy = y > 0.05f ? fabsf(y - 0.26f) : fabsf(y + 0.22f);
            const float field = maxf(dx - 0.14f * a, dy - (y > 0.05f ? 0.15f : 0.17f));
            l.albedo = mul(pale(c1, 0.1f), fabsf(field) < 0.008f ? 0.5f : field < 0 ? 0.9f : 1.0f);
            l.albedo = mul(l.albedo, 0.75f + 0.4f * fbm(v(6.0f * x, 25.0f * y, (float)(seed & 15u)), 4, 25.0f * px));
            if (hypotf(x - 0.42f * a, y + 0.02f) < 0.018f) l.albedo = v(0.6f, 0.45f, 0.15f);
            const float plate = ink_in_box(titles[seed % 16u], x, y - 0.445f, 0.4f * a, 0.03f, 0.16f, px);
            l.albedo = mix(l.albedo, v(0.7f, 0.65f, 0.5f), plate);
            l.gloss = 0.3f;
            return l;
        }
        case CHALK: { // a blackboard with a frame
            const v3 chalk = v(0.66f, 0.66f, 0.62f);
            l.albedo = mul(v(0.035f, 0.045f, 0.04f),
                           0.6f + 0.9f * fbm(v(4.0f * x, 4.0f * y, (float)(seed & 7u)), 4, 4.0f * px));
            const float word = ink_in_box(shops[seed % 14u], x, y - 0.31f, 0.7f * a, 0.16f, 0.12f, px);
            l.albedo = mix(l.albedo, mix(chalk, c1, 0.3f), 0.85f * word);
            if (y < 0.16f && rim > 0.1f) l.albedo = small_print(x, y, 0.085f, l.albedo, chalk, seed, px);
            if (rim < 0.04f) l.albedo = wood_at(x, y, seed, w, seed);
            return l;
        }
        default: { // RUG: borders around a field of lozenges
            const float knots = 0.75f + 0.5f * fbm(v(60.0f * x, 60.0f * y, 0), 2, 60.0f * px);
            const float u = 9.0f * x, q = 9.0f * y, fu = fabsf(u - floorf(u) - 0.5f), fq = fabsf(q - floorf(q) - 0.5f);
            const float middle = fabsf(x) / a + fabsf(y);
            l.albedo = fu + fq < 0.25f ? c3 : fu + fq < 0.42f ? pale(c2, 0.5f) : c1;
            if (fabsf(middle - 0.30f) < 0.03f || middle < 0.1f) l.albedo = pale(c3, 0.3f);
            if (rim < 0.13f)
                l.albedo = floor_int(14.0f * (fabsf(x) > 0.5f * a - 0.13f ? y : x)) & 1 ? c2 : pale(c3, 0.4f);
            if (fabsf(rim - 0.13f) < 0.012f || fabsf(rim - 0.03f) < 0.01f) l.albedo = v(0.07f, 0.06f, 0.07f);
            l.albedo = mul(l.albedo, 0.85f * knots);
            return l;
        }
    }
}

static look look_of_family(const surface* what, v3 p, v3 n, float w) {
    look l = blank(0.0f);
    const material m = what->m;
    const uint32_t seed = what->seed;
    switch (m) {
        case WALL: return look_wall(p, n, seed, w);
        case WALLPAPER: return look_wallpaper(p, n, seed, w);
        case TILES: return look_tiles(p, n, seed, w);
        case PARQUET: return look_parquet(p, seed, w);
        case WOOD: return look_wood(p, n, seed, w);
        case FABRIC: return look_fabric(p, n, seed, w);
        case ENAMEL: return look_enamel(p, seed, w);
        case METAL: return look_metal(p, seed, w);
        case CONCRETE: case ASPHALT: case GRAVEL: case GRASS: return look_ground(m, p, seed, w);
        case MARBLE: case ASHLAR: case ROOF: case BARK: return look_stone(m, p, n, seed, w);
        case FOLIAGE: return look_foliage(p, seed, w);
        case LEAVES: return look_leaves(p, n, seed, w);
        case LABEL: return look_label(p, n, seed, w);
        case CLAY_BRICK: {
            const flat f = flatten(p, n);
            l = look_brick(f.x, f.y, p, (int32_t)(seed & 255u), w);
            l.albedo = mul(mix(l.albedo, times(l.albedo, mul(pale(paint_of(seed, 1), 0.3f), 2.6f)), 0.6f), 1.1f);
            return l;
        }
        case PETAL:
            l.albedo = mul(pale(paint_of(seed >> 16, 4), 0.2f), 0.8f + 0.5f * random3((int32_t)seed, 2, 2));
            return l;
        case GLASSY: // glazed pottery: bands of two colours
            l.gloss = 0.9f;
            l.albedo = sinf((30.0f + 20.0f * part(seed, 1)) * p.z + 3.0f * soft_noise(mul(p, 9.0f), 9.0f * w)) > 0.5f
                           ? paint_of(seed, 2)
                           : pale(paint_of(seed, 1), 0.35f);
            l.albedo = mul(l.albedo, 0.75f + 0.45f * fbm(mul(p, 24.0f), 4, 24.0f * w));
            return l;
        case CHROME: l.gloss = 1.0f, l.mirror = 0.72f, l.albedo = v(0.05f, 0.05f, 0.05f); return l;
        case MIRROR: l.gloss = 1.0f, l.mirror = 0.88f, l.albedo = v(0.01f, 0.01f, 0.01f); return l;
        case PAGES:
            l.albedo = mul(v(0.70f, 0.64f, 0.50f),
                           0.7f + 0.4f * random3(floor_int(p.x * 600.0f), floor_int(p.y * 600.0f), (int32_t)seed));
            return l;
        case GLOW:
            l.albedo = v(0.6f, 0.6f, 0.6f),
            l.glow = mul(mix(v(1.0f, 0.78f, 0.50f), v(0.9f, 0.95f, 1.0f), part(seed, 0)), 2.5f);
            return l;
        default: return look_panel(what, p, w);
    }
}

// Appearance of a surface at point `p` with normal `n`, both in the object's axes; w: width of a pixel.
static look look_at(const surface* what, v3 p, v3 n, float w) {
    const material m = what->m;
    const uint32_t seed = what->seed;
    look l = blank(0.0f);
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
                l.albedo = mix(l.albedo, v(0.30f, 0.31f, 0.08f), 0.7f); // lichen
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
        default: return look_of_family(what, p, n, w);
    }
}

#endif // SCENE_MATERIALS_H
