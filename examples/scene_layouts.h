// scene_layouts.h - the scenes. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_LAYOUTS_H
#define SCENE_LAYOUTS_H

#include "scene_objects.h"

// ---- the courtyard ---------------------------------------------------------------

static const air courtyard_air = {{0.485f, -0.515f, 0.707f},
                                  {3.1f, 2.65f, 2.05f},
                                  {0.70f, 0.77f, 0.84f},
                                  {0.20f, 0.38f, 0.74f},
                                  {0.55f, 0.62f, 0.70f},
                                  0.012f,
                                  {3.1f * 0.3f, 2.65f * 0.3f, 2.05f * 0.3f}};

static void build_courtyard(world* s) {
    s->air = courtyard_air;
    s->capture.focal = 0.9f;
    const place here = {{0, 0, 0}, 0};
    add_patch(s, patch_ground, NULL, 150, 150, PAVING, 0, here);
    static const float walls[4][9] = {{-5, 5, -0.1f, 10, 0, 0, 0, 0, 2.5f},
                                      {5, 5, -0.1f, 0, -10, 0, 0, 0, 2.1f},
                                      {5, -5, -0.1f, -10, 0, 0, 0, 0, 2.5f},
                                      {-5, -5, -0.1f, 0, 10, 0, 0, 0, 2.1f}};
    for (int i = 0; i < 4; i++) {
        const float top = walls[i][2] + walls[i][8];
        add_patch(s, patch_rectangle, walls[i], 60, 16, i & 1 ? PLASTER : BRICK, (uint32_t)i, here);
        if (i & 1)
            add_box(s, v(walls[i][0] - 0.18f, -5.2f, top), v(walls[i][0] + 0.18f, 5.2f, top + 0.09f), 12, COPING, 0,
                    here);
        else
            add_box(s, v(-5.2f, walls[i][1] - 0.18f, top), v(5.2f, walls[i][1] + 0.18f, top + 0.09f), 12, COPING, 0,
                    here);
    }
    // the table with its cloth
    const place table = {{0, 0, 0}, 0.35f};
    add_box(s, v(-0.75f, -0.46f, 0.60f), v(0.75f, 0.46f, 0.64f), 24, PLANKS, 1, table);
    for (int i = 0; i < 4; i++) {
        const float x = i & 1 ? 0.66f : -0.66f, y = i & 2 ? 0.37f : -0.37f;
        add_box(s, v(x - 0.04f, y - 0.04f, -0.05f), v(x + 0.04f, y + 0.04f, 0.60f), 6, PLANKS, 2 + (uint32_t)i, table);
    }
    for (int i = 0; i < 2; i++)
        add_box(s, v(-0.66f, i ? 0.35f : -0.38f, 0.50f), v(0.66f, i ? 0.38f : -0.35f, 0.60f), 8, PLANKS, 8, table);
    const float length[1] = {1.5f};
    const place cloth = {{0, 0, 0.641f}, 0.35f};
    add_patch(s, patch_cloth, length, 120, 24, CLOTH, 0, cloth);
    // on the table
    static const float vase[] = {9,     0.0f,  0.0f,  0.075f, 0.0f,   0.085f, 0.03f, 0.125f, 0.13f, 0.135f,
                                 0.20f, 0.10f, 0.28f, 0.052f, 0.335f, 0.06f,  0.37f, 0.078f, 0.385f};
    const place vase_at = {{-0.16f, 0.06f, 0.645f}, 0};
    add_patch(s, patch_lathe, vase, 48, 48, GLAZE, 0, vase_at);
    const place flowers = {{-0.16f, 0.06f, 0.96f}, 0};
    add_bush(s, flowers, 0.19f, 0.34f, 90, 31);
    for (int i = 0; i < 4; i++) { // books
        const float z = 0.645f + 0.045f * (float)i, w = 0.105f - 0.006f * (float)i;
        const place at = {{0.40f, 0.22f, z}, 0.5f + 0.45f * (float)((i * 7) % 4) - 0.3f};
        add_box(s, v(-w, -0.15f, 0), v(w, 0.15f, 0.043f), 8, BOOK, (uint32_t)i, at);
    }
    static const float apple[1] = {0.055f};
    static const float fruit[6][3] = {{0.14f, -0.20f, 0}, {0.26f, -0.13f, 1},  {0.16f, -0.07f, 0},
                                      {0.30f, -0.26f, 1}, {0.405f, 0.215f, 0}, {-0.50f, -0.05f, 1}};
    for (int i = 0; i < 6; i++) {
        const float orange[4] = {0.052f, 0.95f, 0.02f, (float)i};
        const place at = {{fruit[i][0], fruit[i][1], i == 4 ? 0.872f : 0.695f}, 1.3f * (float)i};
        if (fruit[i][2] > 0) add_patch(s, patch_sphere, orange, 28, 18, ORANGE, (uint32_t)i, at);
        else add_patch(s, patch_apple, apple, 28, 20, APPLE, (uint32_t)i, at);
    }
    static const float wreath[2] = {0.17f, 0.045f};
    const place wreath_at = {{-0.46f, -0.18f, 0.690f}, 0};
    add_patch(s, patch_torus, wreath, 72, 20, ROPE, 0, wreath_at);
    // around the table
    static const float ball[4] = {0.26f, 1, 0, 0};
    const place ball_at = {{0.95f, -0.85f, 0.255f}, 0.8f};
    add_patch(s, patch_sphere, ball, 48, 32, BALL, 0, ball_at);
    const place crate = {{-1.25f, -0.55f, 0}, 0.5f}, small_crate = {{-1.22f, -0.52f, 0.46f}, 1.1f};
    add_box(s, v(-0.27f, -0.27f, -0.02f), v(0.27f, 0.27f, 0.46f), 12, PLANKS, 20, crate);
    add_box(s, v(-0.16f, -0.13f, 0), v(0.16f, 0.13f, 0.24f), 10, PLANKS, 27, small_crate);
    static const float pot[] = {8,      0.0f,  0.0f,   0.14f, 0.0f,  0.17f, 0.12f,  0.21f, 0.28f,
                                0.235f, 0.33f, 0.235f, 0.38f, 0.20f, 0.37f, 0.195f, 0.33f};
    static const float soil[9] = {-0.17f, -0.17f, 0.335f, 0.34f, 0, 0, 0, 0.34f, 0};
    static const float pots[3][3] = {{1.15f, 0.75f, 0.42f}, {-0.75f, 1.25f, 0.34f}, {-2.6f, 1.2f, 0.5f}};
    for (int i = 0; i < 3; i++) {
        const place at = {{pots[i][0], pots[i][1], 0}, (float)i}, above = {{pots[i][0], pots[i][1], 0.30f}, (float)i};
        add_patch(s, patch_lathe, pot, 40, 36, TERRACOTTA, (uint32_t)i, at);
        add_patch(s, patch_rectangle, soil, 4, 4, SOIL, 0, at);
        add_bush(s, above, 0.30f, 2.0f * pots[i][2], 230, 40 + (uint64_t)i);
    }
    static const float rocks[5][3] = {{0.25f, 1.35f, 0.20f},
                                      {0.55f, 1.52f, 0.13f},
                                      {-0.35f, -1.45f, 0.17f},
                                      {1.9f, 0.1f, 0.22f},
                                      {-1.9f, 0.2f, 0.15f}};
    for (int i = 0; i < 5; i++) {
        const float shape[4] = {rocks[i][2], 0.75f, 0.7f, 3.7f * (float)i};
        const place at = {{rocks[i][0], rocks[i][1], 0.45f * rocks[i][2]}, (float)i};
        add_patch(s, patch_sphere, shape, 40, 26, GRANITE, (uint32_t)i, at);
    }
}

// ---- shells ----------------------------------------------------------------------

static const float half_turn = 3.1415927f;

// The sun stands in the direction `from` or up to `swing` beside it; one sky in four is overcast.
static void set_daylight(world* s, float from, float swing) {
    const float a = from + draw(s, -swing, swing), up = draw(s, 0.45f, 0.95f), warm = draw(s, 0.0f, 1.0f);
    const int overcast = draw(s, 0, 1) < 0.25f;
    s->air.sun_direction = unit(v(cosf(a), sinf(a), up * 1.1f));
    s->air.sun_color =
        overcast ? v(0, 0, 0) : mul(mix(v(3.2f, 2.3f, 1.5f), v(3.1f, 2.8f, 2.4f), warm), draw(s, 0.8f, 1.15f));
    s->air.horizon = overcast ? v(0.70f, 0.72f, 0.76f) : mix(v(0.86f, 0.74f, 0.62f), v(0.72f, 0.79f, 0.86f), warm);
    s->air.zenith = overcast ? v(0.40f, 0.44f, 0.51f) : mix(v(0.28f, 0.36f, 0.62f), v(0.18f, 0.36f, 0.74f), warm);
    s->air.haze = mul(add(s->air.horizon, s->air.zenith), 0.4f);
    s->air.haze_density = 0.002f;
    s->air.fill = mul(s->air.sun_color, 0.3f);
}

static void set_indoors(world* s) {
    s->air.haze_density = 0.0f;
    s->air.fill = v(0.08f, 0.07f, 0.06f);
}

static void set_capture(world* s, int kind, float focal, v3 aim) {
    memset(&s->capture, 0, sizeof s->capture);
    s->capture.kind = kind, s->capture.focal = focal, s->capture.aim = aim;
}
static void set_orbit(world* s, float focal, v3 aim, float distance, float height, float start) {
    set_capture(s, ORBIT, focal, aim);
    s->capture.distance = distance, s->capture.height = height, s->capture.start = start;
}
static void set_forward(world* s, float focal, v3 aim, v3 from, float spread) {
    set_capture(s, FORWARD, focal, aim);
    s->capture.from = from, s->capture.spread = spread;
}
static void set_walk(world* s, float focal, v3 from, v3 to, float sway, float turn) {
    set_capture(s, WALK, focal, to);
    s->capture.from = from, s->capture.spread = sway, s->capture.turn = turn;
}

typedef struct opening {
    float x0, x1, z0, z1;
} opening; // of a wall; in the order of x, none overlap

// A wall in the plane y = 0 from x = 0, facing -y. Openings have reveals; those above the floor are windows with bars.
static void add_wall(world* s, float length, float height, material m, uint32_t seed, const opening* o, int count,
                     place where) {
    float x = 0.0f;
    for (int i = 0; i <= count; i++) {
        const float next = i < count ? o[i].x0 : length;
        if (next > x) add_sheet(s, v(x, 0, 0), v(next - x, 0, 0), v(0, 0, height), 0.22f, m, seed, where);
        if (i == count) return;
        const float x0 = o[i].x0, x1 = o[i].x1, z0 = o[i].z0, z1 = o[i].z1, d = 0.22f;
        if (z0 > 0.0f) add_sheet(s, v(x0, 0, 0), v(x1 - x0, 0, 0), v(0, 0, z0), 0.22f, m, seed, where);
        add_sheet(s, v(x0, 0, z1), v(x1 - x0, 0, 0), v(0, 0, height - z1), 0.22f, m, seed, where);
        add_sheet(s, v(x0, 0, z0), v(0, d, 0), v(0, 0, z1 - z0), 0.22f, m, seed, where); // faces +x
        add_sheet(s, v(x1, 0, z0), v(0, 0, z1 - z0), v(0, d, 0), 0.22f, m, seed, where); // -x
        add_sheet(s, v(x0, 0, z1), v(0, d, 0), v(x1 - x0, 0, 0), 0.22f, m, seed, where); // down
        if (z0 > 0.0f) {
            add_block(s, v(x0 - 0.05f, -0.06f, z0 - 0.04f), v(x1 + 0.05f, d, z0), 0.2f, ENAMEL, WHITE, where); // sill
            for (int k = 0; k <= 2; k++) {
                const float bar = x0 + (x1 - x0) * 0.5f * (float)k, rail = z0 + (z1 - z0) * 0.5f * (float)k;
                add_block(s, v(bar - 0.025f, d - 0.06f, z0), v(bar + 0.025f, d - 0.02f, z1), 0.3f, ENAMEL, WHITE,
                          where);
                add_block(s, v(x0, d - 0.06f, rail - 0.02f), v(x1, d - 0.02f, rail + 0.02f), 0.3f, ENAMEL, WHITE,
                          where);
            }
        }
        x = x1;
    }
}

// A room around the origin with half sides X and Y; `windows` are those of its four walls.
enum { NORTH, EAST, SOUTH, WEST };
typedef struct room_plan {
    float x, y, height;
    material floor, walls, ceiling;
    uint32_t seed;
} room_plan;

static place wall_of(const room_plan* r, int side) {
    switch (side) {
        case NORTH: return place_at(-r->x, r->y, 0, 0);
        case EAST: return place_at(r->x, r->y, 0, -0.5f * half_turn);
        case SOUTH: return place_at(r->x, -r->y, 0, half_turn);
        default: return place_at(-r->x, -r->y, 0, 0.5f * half_turn);
    }
}
static float wall_length(const room_plan* r, int side) { return 2.0f * (side == NORTH || side == SOUTH ? r->x : r->y); }

static void add_room(world* s, const room_plan* r, const opening* windows[4], const int counts[4]) {
    const place here = place_at(0, 0, 0, 0);
    add_sheet(s, v(-r->x, -r->y, 0), v(2 * r->x, 0, 0), v(0, 2 * r->y, 0), 0.18f, r->floor, r->seed + 3u, here);
    add_sheet(s, v(-r->x, -r->y, r->height), v(0, 2 * r->y, 0), v(2 * r->x, 0, 0), 0.25f, r->ceiling,
              (r->seed + 6u) & ~1u, here);
    for (int side = 0; side < 4; side++) {
        const place where = wall_of(r, side);
        const float length = wall_length(r, side);
        add_wall(s, length, r->height, r->walls, r->seed, windows[side], counts[side], where);
        float x = 0.0f; // skirting, except at doors
        for (int i = 0; i <= counts[side]; i++) {
            const int door = i < counts[side] && windows[side][i].z0 <= 0.0f;
            if (i < counts[side] && !door) continue;
            const float next = door ? windows[side][i].x0 : length;
            add_block(s, v(x, -0.015f, 0), v(next, 0, 0.09f), 0.3f, WOOD, r->seed + 1u, where);
            x = door ? windows[side][i].x1 : length;
        }
        add_block(s, v(0, -0.04f, r->height - 0.06f), v(length, 0, r->height), 0.3f, ENAMEL, WHITE, where);
    }
}

static void add_outdoors(world* s, float half, material m, uint32_t seed) { // the ground, finer in the middle
    const place here = place_at(0, 0, 0, 0);
    add_sheet(s, v(-0.35f * half, -0.35f * half, 0), v(0.7f * half, 0, 0), v(0, 0.7f * half, 0), 0.008f * half, m, seed,
              here);
    add_sheet(s, v(-half, -half, 0), v(2 * half, 0, 0), v(0, 0.65f * half, 0), 0.04f * half, m, seed, here);
    add_sheet(s, v(-half, 0.35f * half, 0), v(2 * half, 0, 0), v(0, 0.65f * half, 0), 0.04f * half, m, seed, here);
    add_sheet(s, v(-half, -0.35f * half, 0), v(0.65f * half, 0, 0), v(0, 0.7f * half, 0), 0.04f * half, m, seed, here);
    add_sheet(s, v(0.35f * half, -0.35f * half, 0), v(0.65f * half, 0, 0), v(0, 0.7f * half, 0), 0.04f * half, m, seed,
              here);
}

// ---- houses ----------------------------------------------------------------------

static void add_house_window(world* s, float x, float z, float width, float height, uint32_t seed, int style,
                             place where) {
    const float b = 0.07f, d = 0.06f;
    add_panel(s, v(x, -0.015f, z), v(1, 0, 0), v(0, 0, 1), width, height, WINDOW, seed, where);
    for (int i = -1; i <= 1; i += 2) {
        const float side = x + 0.5f * (float)i * width, level = z + 0.5f * (float)i * height;
        add_block(s, v(side - b, -d, z - 0.5f * height), v(side + b, 0, z + 0.5f * height), 0.5f,
                  style & 1 ? ASHLAR : ENAMEL, WHITE, where);
        add_block(s, v(x - 0.5f * width - 0.13f, i < 0 ? -0.16f : -0.09f, level - b),
                  v(x + 0.5f * width + 0.13f, 0, level + b), 0.5f, style & 1 ? ASHLAR : ENAMEL, WHITE, where);
        if (style & 2) // shutters
            add_panel(s, v(x + (float)i * (0.74f * width + 0.08f), -0.05f, z), v(1, 0, 0), v(0, 0, 1), 0.42f * width,
                      height, SHUTTER, seed & ~63u, where);
    }
    if (style & 4) { // flowers
        add_block(s, v(x - 0.45f * width, -0.30f, z - 0.5f * height),
                  v(x + 0.45f * width, -0.12f, z - 0.5f * height + 0.15f), 0.3f, TERRACOTTA, 1, where);
        add_crown(s, v(0.45f * width, 0.12f, 0.14f), 90, 0.10f, draw_seed(s), 0.45f,
                  within(where, x, -0.22f, z - 0.5f * height + 0.2f, 0));
    }
}

static void add_shop(world* s, float width, uint32_t seed, place where) { // its ground floor
    const float glass = 0.5f * width - 0.9f, door = 0.5f * width;
    add_block(s, v(0.15f, -0.12f, 2.55f), v(width - 0.15f, 0, 3.05f), 0.4f, WOOD, seed, where);
    add_panel(s, v(0.5f * width, -0.125f, 2.80f), v(1, 0, 0), v(0, 0, 1), 0.86f * width, 0.44f, SIGN, seed, where);
    for (int i = -1; i <= 1; i += 2) {
        const float x = door + (float)i * (0.5f * glass + 0.62f);
        add_house_window(s, x, 1.5f, glass, 1.75f, seed & ~48u, 0, where);
        add_block(s, v(x - 0.5f * glass, -0.10f, 0), v(x + 0.5f * glass, 0, 0.55f), 0.4f, WOOD, seed, where);
    }
    add_panel(s, v(door, -0.03f, 1.15f), v(1, 0, 0), v(0, 0, 1), 1.0f, 2.3f, DOOR, seed, where);
    if (seed & 2u) { // awning
        const v3 top = v(0.3f, -0.12f, 2.5f), edge = v(width - 0.6f, 0, 0), out = v(0, -1.0f, -0.42f);
        add_sheet(s, add(top, out), edge, mul(out, -1.0f), 0.2f, FABRIC, fabric_of(seed, 1), where);
        add_sheet(s, add(add(top, out), v(0, 0, -0.18f)), edge, v(0, 0, 0.18f), 0.2f, FABRIC, fabric_of(seed, 1),
                  where);
        for (int i = 0; i < 2; i++)
            add_tube(s, v(0.35f + (float)i * (width - 0.7f), 0, 2.05f),
                     add(add(top, out), v((float)i * (width - 0.7f) + 0.05f, 0, 0)), 0.012f, 0.012f, 5, METAL, 1,
                     where);
    }
    if (seed & 4u) { // a sign that hangs out
        const float x = width - 0.35f;
        add_tube(s, v(x, 0, 3.45f), v(x, -0.85f, 3.45f), 0.015f, 0.015f, 6, METAL, 2, where);
        add_tube(s, v(x, 0, 3.15f), v(x, -0.6f, 3.45f), 0.010f, 0.010f, 6, METAL, 2, where);
        for (int i = -1; i <= 1; i += 2)
            add_panel(s, v(x + 0.012f * (float)i, -0.5f, 3.17f), v(0, (float)i, 0), v(0, 0, 1), 0.62f, 0.42f, SIGN,
                      seed, where);
    }
}

static float add_house(world* s, float width, int floors, int shop,
                       place where) { // front in y = 0 from x = 0; returns its height
    static const material fronts[4] = {CLAY_BRICK, WALL, ASHLAR, WALL};
    const uint32_t seed = draw_seed(s);
    const float ground = 3.2f, storey = 2.8f, height = ground + storey * (float)(floors - 1) + 0.3f;
    const int columns = (int)maxf(2.0f, width / 1.75f), style = (int)(seed >> 3) & 7;
    const material front = fronts[seed % 4u];
    add_sheet(s, v(0, 0, 0), v(width, 0, 0), v(0, 0, height), 0.4f, front, seed & ~1u, where);
    add_sheet(s, v(0, 6, 0), v(0, -6, 0), v(0, 0, height), 0.8f, front, seed & ~1u, where);
    add_sheet(s, v(width, 0, 0), v(0, 6, 0), v(0, 0, height), 0.8f, front, seed & ~1u, where);
    add_block(s, v(0, -0.05f, 0), v(width, 0, 0.35f), 0.5f, ASHLAR, seed, where);
    add_block(s, v(-0.04f, -0.28f, height), v(width + 0.04f, 0.1f, height + 0.16f), 0.4f, seed & 16u ? ASHLAR : ENAMEL,
              WHITE, where);
    add_sheet(s, v(-0.05f, -0.3f, height + 0.16f), v(width + 0.1f, 0, 0), v(0, 3.2f, 1.9f), 0.4f, ROOF, seed, where);
    for (int f = 1; f < floors; f++) {
        const float z = ground + storey * ((float)f - 0.5f);
        for (int c = 0; c < columns; c++) {
            const float x = width * ((float)c + 0.5f) / (float)columns;
            add_house_window(s, x, z, 0.85f, 1.45f, seed + (uint32_t)draw_int(s, 2) * 64u, style & (f == 1 ? 7 : 3),
                             where);
        }
        add_block(s, v(0, -0.07f, ground + storey * (float)(f - 1) - 0.06f),
                  v(width, 0, ground + storey * (float)(f - 1) + 0.06f), 0.5f, ASHLAR, seed, where);
    }
    if (shop) {
        add_shop(s, width, seed, where);
    } else {
        const float door = width * (0.5f + 0.28f * (float)(seed & 1u ? 1 : -1));
        for (int c = 0; c < columns; c++) {
            const float x = width * ((float)c + 0.5f) / (float)columns;
            if (fabsf(x - door) > 1.15f)
                add_house_window(s, x, 1.75f, 0.85f, 1.4f, seed + 64u * (uint32_t)c, style, where);
        }
        add_panel(s, v(door, -0.03f, 1.2f), v(1, 0, 0), v(0, 0, 1), 1.05f, 2.2f, DOOR, seed, where);
        for (int i = -1; i <= 1; i += 2)
            add_block(s, v(door + 0.6f * (float)i - 0.09f, -0.09f, 0), v(door + 0.6f * (float)i + 0.09f, 0, 2.42f),
                      0.4f, ASHLAR, seed, where);
        add_block(s, v(door - 0.78f, -0.35f, 2.35f), v(door + 0.78f, 0, 2.5f), 0.3f, ASHLAR, seed, where);
        add_block(s, v(door - 0.75f, -0.6f, 0), v(door + 0.75f, 0, 0.14f), 0.3f, ASHLAR, seed, where);
    }
    if (floors > 2 && seed & 32u) { // balcony
        const float x = 0.5f * width - 0.9f, z = ground + 0.02f;
        add_block(s, v(x - 0.1f, -0.85f, z - 0.1f), v(x + 1.9f, 0, z), 0.2f, ASHLAR, seed, where);
        add_railing(s, 1.8f, 0.9f, 0.11f, 0.009f, METAL, seed, within(where, x, -0.8f, z, 0));
        add_railing(s, 0.75f, 0.9f, 0.11f, 0.009f, METAL, seed, within(where, x, -0.78f, z, 0.5f * half_turn));
        add_railing(s, 0.75f, 0.9f, 0.11f, 0.009f, METAL, seed, within(where, x + 1.8f, -0.78f, z, 0.5f * half_turn));
    }
    add_tube(s, v(0.12f, -0.09f, 0), v(0.12f, -0.09f, height), 0.045f, 0.045f, 8, METAL, seed, where);
    return height;
}

static void add_row_of_houses(world* s, float length, int shops, place where) {
    for (float x = 0.0f; x < length - 1.0f;) {
        const float width = minf(draw(s, 4.2f, 6.4f), length - x);
        add_house(s, maxf(width, 3.4f), 2 + draw_int(s, 3), shops ? draw(s, 0, 1) < 0.7f : 0,
                  within(where, x, 0, 0, 0));
        x += maxf(width, 3.4f);
    }
}

static void add_chalkboard(world* s, place where) { // on legs, faces -y
    const uint32_t seed = draw_seed(s);
    for (int i = -1; i <= 1; i += 2) {
        const v3 up = unit(v(0, 0.22f * (float)-i, 1.0f));
        add_panel(s, v(0, 0.13f * (float)i, 0.52f), v((float)-i, 0, 0), up, 0.56f, 0.95f, CHALK, seed, where);
    }
}

// ---- layouts ---------------------------------------------------------------------

static const opening* const no_windows[4] = {NULL, NULL, NULL, NULL};

// Trinkets on a surface of the given size, apart from each other.
static void scatter(world* s, int count, float length, float depth, float size, place where) {
    float taken[24][3];
    int placed = 0;
    for (int i = 0; i < 12 * count && placed < count && placed < 24; i++) {
        const float scale = size * draw(s, 0.75f, 1.3f), x = draw(s, -0.5f, 0.5f) * (length - scale),
                    y = draw(s, -0.5f, 0.5f) * (depth - scale);
        int free_place = 1;
        for (int k = 0; k < placed; k++)
            free_place &= hypotf(x - taken[k][0], y - taken[k][1]) > 0.52f * (scale + taken[k][2]);
        if (!free_place) continue;
        taken[placed][0] = x, taken[placed][1] = y, taken[placed++][2] = scale;
        add_trinket(s, scale, within(where, x, y, 0, draw(s, -3.0f, 3.0f)));
    }
}

static void build_still_life(world* s) {
    const uint32_t seed = draw_seed(s);
    const int indoors = draw(s, 0, 1) < 0.5f;
    const place table = place_at(0, 0, 0, draw(s, -0.5f, 0.5f));
    const float length = draw(s, 1.3f, 1.7f), depth = draw(s, 0.8f, 0.95f);
    set_daylight(s, -0.6f, 0.9f);
    if (indoors) {
        const room_plan r = {3.1f, 3.1f, 2.8f, seed & 4u ? TILES : PARQUET, seed & 8u ? WALLPAPER : WALL, WALL, seed};
        const opening wide[2] = {{0.8f, 2.4f, 0.8f, 2.3f}, {3.6f, 5.2f, 0.8f, 2.3f}};
        const opening* windows[4] = {NULL, wide, wide, NULL};
        const int counts[4] = {0, 2, 2, 0};
        set_indoors(s);
        add_room(s, &r, windows, counts);
        for (int i = 0; i < 3; i++) {
            const place north = wall_of(&r, NORTH), west = wall_of(&r, WEST);
            hang_panel(s, v(1.2f + 1.9f * (float)i, -0.02f, draw(s, 1.45f, 1.75f)), -0.5f * half_turn,
                       draw(s, 0.6f, 1.2f), draw(s, 0.5f, 0.8f), PICTURE, draw_seed(s), north);
            hang_panel(s, v(1.2f + 1.9f * (float)i, -0.02f, draw(s, 1.45f, 1.75f)), -0.5f * half_turn,
                       draw(s, 0.5f, 0.9f), draw(s, 0.6f, 0.9f), i == 1 ? MIRROR : POSTER, draw_seed(s), west);
        }
        add_pendant(s, v(0, 0, 2.15f), r.height, draw(s, 0.6f, 1.6f));
        add_potted_plant(s, 1.4f, place_at(-2.5f, 2.5f, 0, 0));
        add_potted_plant(s, 1.2f, place_at(2.5f, 2.6f, 0, 0));
        add_sofa(s, 1.6f, draw_seed(s), place_at(0.3f, 2.6f, 0, half_turn));
    } else {
        static const material grounds[4] = {PAVING, GRAVEL, GRASS, CONCRETE};
        add_outdoors(s, 9.0f, grounds[seed % 4u], seed);
        for (int i = 0; i < 4; i++) {
            const place side = place_at(0, 0, 0, 0.5f * half_turn * (float)i);
            if ((seed >> (4 + i)) & 1u) add_hedge(s, 8.0f, 0.5f, draw(s, 1.0f, 1.6f), within(side, 0, 4.2f, 0, 0));
            else add_pickets(s, 8.0f, 1.1f, seed, within(side, -4.0f, 4.2f, 0, 0));
            add_tree(s, draw(s, 3.2f, 4.4f), 1600, within(side, draw(s, -3.0f, 3.0f), 5.6f, 0, draw(s, 0, 6)));
        }
        add_flowers(s, 3.0f, 0.6f, 40, place_at(0, 3.4f, 0, 0));
        add_potted_plant(s, 1.2f, place_at(-1.9f, 1.7f, 0, 0));
        add_bicycle(s, place_at(2.0f, 2.8f, 0, 0.2f));
    }
    add_table(s, length, depth, 0.74f, seed, table);
    add_sheet(s, v(-0.36f * length, -0.5f * depth + 0.1f, 0.743f), v(0.72f * length, 0, 0), v(0, depth - 0.2f, 0),
              0.05f, FABRIC, draw_seed(s), table);
    scatter(s, 10, length, depth, 0.24f, within(table, 0, 0, 0.744f, 0));
    for (int i = 0; i < 3; i++) {
        const float a = 0.7f + 1.9f * (float)i + draw(s, -0.3f, 0.3f);
        add_chair(s, seed,
                  within(table, 1.15f * cosf(a), 1.0f * sinf(a), 0, a + 0.5f * half_turn + draw(s, -0.4f, 0.4f)));
    }
    add_fruit_crate(s, within(table, -1.1f, -0.7f, 0, 0.4f));
    set_orbit(s, indoors ? 0.8f : 0.9f, v(0, 0, 0.72f), 2.1f, 1.45f, -0.5f * half_turn);
}

static void build_living_room(world* s) {
    const uint32_t seed = draw_seed(s);
    const room_plan r = {draw(s, 2.7f, 3.3f),
                    draw(s, 2.4f, 2.9f),
                    draw(s, 2.5f, 2.9f),
                    PARQUET,
                    seed & 1u ? WALLPAPER : WALL,
                    WALL,
                    seed};
    const float mid = r.y;
    const opening wide[1] = {{mid - 1.3f, mid + 1.1f, 0.5f, 2.2f}}, south[1] = {{0.5f, 1.8f, 0.9f, 2.1f}};
    const opening* windows[4] = {NULL, wide, south, NULL};
    const int counts[4] = {0, 1, 1, 0};
    const place north = wall_of(&r, NORTH), east = wall_of(&r, EAST), west = wall_of(&r, WEST);
    set_daylight(s, 0.0f, 0.7f);
    set_indoors(s);
    add_room(s, &r, windows, counts);
    add_panel(s, v(0, 0.1f, 0.006f), v(1, 0, 0), v(0, 1, 0), 2.5f, 1.7f, RUG, seed,
              place_at(0, 0, 0, draw(s, -0.1f, 0.1f)));
    add_sofa(s, 1.9f, draw_seed(s), within(north, r.x - 0.2f, -0.5f, 0, half_turn));
    add_table(s, 1.0f, 0.55f, 0.42f, seed + 1u, place_at(-0.1f, 0.4f, 0, draw(s, -0.15f, 0.15f)));
    scatter(s, 4, 1.0f, 0.55f, 0.2f, place_at(-0.1f, 0.4f, 0.421f, 0.1f));
    add_standing_lamp(s, 1.6f, draw(s, 0.5f, 1.4f), within(north, 2 * r.x - 0.45f, -0.45f, 0, 0));
    add_potted_plant(s, 1.5f, within(north, 0.4f, -0.4f, 0, 0));
    for (int i = 0; i < 3; i++) // above the sofa
        hang_panel(s, v(r.x - 1.0f + 0.85f * (float)i, -0.02f, 1.62f), -0.5f * half_turn, draw(s, 0.5f, 0.75f),
                   draw(s, 0.5f, 0.85f), i == 1 && seed & 2u ? MIRROR : PICTURE, draw_seed(s), north);
    const place shelf = within(west, mid - 1.2f, -0.3f, 0, 0); // bookcase
    for (int i = 0; i <= 5; i++)
        add_block(s, v(0, 0, 0.38f * (float)i), v(2.2f, 0.29f, 0.38f * (float)i + 0.025f), 0.15f, WOOD, seed + 2u,
                  shelf);
    for (int i = 0; i <= 2; i++)
        add_block(s, v(1.1f * (float)i - 0.012f, 0, 0), v(1.1f * (float)i + 0.012f, 0.29f, 1.93f), 0.2f, WOOD,
                  seed + 2u, shelf);
    for (int i = 0; i < 10; i++) {
        const float x = 0.02f + 1.1f * (float)(i / 5), z = 0.026f + 0.38f * (float)(i % 5);
        if (draw(s, 0, 1) < 0.65f) add_books(s, draw(s, 0.6f, 1.04f), 0.24f, 0.33f, within(shelf, x, 0.02f, z, 0));
        else
            for (int k = 0; k < 3; k++)
                add_trinket(s, draw(s, 0.2f, 0.28f),
                            within(shelf, x + 0.2f + 0.33f * (float)k, 0.14f, z, draw(s, -1, 1)));
    }
    for (int i = -1; i <= 1; i += 2) { // curtains
        const float shape[4] = {0.55f, 2.2f, 0.05f, 6.0f};
        add_patch(s, patch_drape, shape, 60, 12, FABRIC, seed + 8u,
                  within(east, mid - 0.1f + 1.45f * (float)i, -0.1f, 0.08f, 0));
    }
    add_tube(s, v(mid - 1.9f, -0.1f, 2.3f), v(mid + 1.7f, -0.1f, 2.3f), 0.014f, 0.014f, 8, METAL, 1, east);
    add_chair(s, seed, place_at(1.5f, 0.7f, 0, 1.4f));
    add_cushion(s, v(0.3f, 0.3f, 0.2f), 0.5f, FABRIC, draw_seed(s), place_at(-1.35f, 0.2f, 0.2f, 0.3f));
    add_hedge(s, 8.0f, 0.6f, 1.4f, place_at(r.x + 3.0f, 0, 0, 0.5f * half_turn));
    add_tree(s, 4.0f, 700, place_at(r.x + 4.0f, 1.0f, 0, 0));
    add_sheet(s, v(r.x + 0.3f, -9, -0.02f), v(12, 0, 0), v(0, 18, 0), 1.0f, GRASS, seed, place_at(0, 0, 0, 0));
    set_orbit(s, 0.72f, v(-0.1f, 0.75f, 0.75f), 2.1f, 1.5f, -0.5f * half_turn + draw(s, -0.15f, 0.15f));
}

static void build_corridor(world* s) {
    const uint32_t seed = draw_seed(s);
    const room_plan r = {draw(s, 1.05f, 1.4f),
                    7.0f,
                    draw(s, 2.4f, 2.9f),
                    seed & 1u ? TILES : PARQUET,
                    seed & 2u   ? WALL
                    : seed & 4u ? CLAY_BRICK
                                : WALLPAPER,
                    WALL,
                    seed};
    const opening end[1] = {{0.35f, 2.0f * r.x - 0.35f, 0.7f, 2.1f}},
                  side[2] = {{2.2f, 3.6f, 0.8f, 2.1f}, {8.4f, 9.8f, 0.8f, 2.1f}};
    const opening* windows[4] = {end, side, NULL, NULL};
    const int counts[4] = {1, seed & 8u ? 2 : 0, 0, 0};
    set_daylight(s, 0.4f, 0.5f);
    set_indoors(s);
    add_room(s, &r, windows, counts);
    for (int w = 0; w < 2; w++) {
        const place wall = wall_of(&r, w ? WEST : EAST);
        for (int i = 0; i < 6; i++) {
            const float x = 1.1f + 2.3f * (float)i + (w ? 0.5f : 0.0f);
            int at_window = 0;
            for (int k = 0; !w && k < counts[1]; k++) at_window |= x + 0.7f > side[k].x0 && x - 0.7f < side[k].x1;
            if (at_window) continue;
            if ((i + w) % 2 == 0) { // a door in its frame
                add_panel(s, v(x, -0.03f, 1.03f), v(1, 0, 0), v(0, 0, 1), 0.9f, 2.04f, DOOR, seed + (uint32_t)w, wall);
                for (int k = -1; k <= 1; k += 2)
                    add_block(s, v(x + 0.5f * (float)k - 0.05f, -0.07f, 0), v(x + 0.5f * (float)k + 0.05f, 0, 2.1f),
                              0.3f, WOOD, seed, wall);
                add_block(s, v(x - 0.55f, -0.07f, 2.06f), v(x + 0.55f, 0, 2.16f), 0.3f, WOOD, seed, wall);
            } else {
                const int kind = draw_int(s, 4);
                hang_panel(s, v(x, -0.02f, 1.55f), -0.5f * half_turn, draw(s, 0.6f, 0.95f), draw(s, 0.75f, 0.95f),
                           kind == 0   ? PICTURE
                           : kind == 1 ? CHALK
                                       : POSTER,
                           draw_seed(s), wall);
                if (kind == 2)
                    add_railing(s, 0.9f, 0.6f, 0.06f, 0.018f, ENAMEL, WHITE,
                                within(wall, x - 0.45f, -0.1f, 0.12f, 0)); // radiator
                else if (kind == 3) add_chair(s, seed, within(wall, x, -0.3f, 0, half_turn));
                else add_potted_plant(s, draw(s, 0.8f, 1.2f), within(wall, x, -0.28f, 0, 0));
            }
        }
        for (int i = 0; i < 2; i++) // pipes and a cable
            add_tube(s, v(0, -0.12f - 0.1f * (float)i, r.height - 0.18f),
                     v(14, -0.12f - 0.1f * (float)i, r.height - 0.18f), 0.03f, 0.03f, 8, i ? METAL : ENAMEL, seed,
                     wall);
        for (int i = 0; i < 7; i++)
            add_cable(s, v(2.0f * (float)i, -0.05f, r.height - 0.35f),
                      v(2.0f * (float)i + 2.0f, -0.05f, r.height - 0.35f), 0.008f, 0.08f, METAL, wall);
    }
    for (int i = 0; i < 5; i++) { // lamps
        const float y = -5.6f + 2.8f * (float)i;
        add_block(s, v(-0.3f, y - 0.45f, r.height - 0.05f), v(0.3f, y + 0.45f, r.height), 0.2f, GLOW, seed,
                  place_at(0, 0, 0, 0));
    }
    for (int i = 0; i < 3; i++)
        add_lamp_bulb(s, v(0, -4.2f + 4.2f * (float)i, r.height - 0.3f), v(1.1f, 1.02f, 0.9f), 0.2f);
    add_panel(s, v(0, 0.5f, 0.006f), v(0, 1, 0), v(-1, 0, 0), 6.5f, 0.95f * r.x, RUG, seed, place_at(0, 0, 0, 0));
    add_fruit_crate(s, place_at(r.x - 0.35f, 2.9f, 0, 1.6f));
    add_bicycle(s, place_at(-r.x + 0.35f, 4.6f, 0, 0.5f * half_turn));
    add_sheet(s, v(-9, 7.3f, -2), v(18, 0, 0), v(0, 12, 0), 1.0f, GRASS, seed, place_at(0, 0, 0, 0));
    if (counts[1]) add_hedge(s, 14.0f, 0.6f, 3.2f, place_at(r.x + 3.5f, 0, -1.2f, 0.5f * half_turn));
    add_tree(s, 5.0f, 900, place_at(0.8f, 10.5f, -2, 0));
    set_walk(s, 0.75f, v(0, -6.2f, 1.5f), v(0, 2.2f, 1.5f), 0.3f * r.x, 0.42f);
}

static void build_bookshelf(world* s) {
    const uint32_t seed = draw_seed(s);
    const float width = draw(s, 2.3f, 2.9f), step = 0.36f;
    const int columns = 3, rows = 6;
    const room_plan r = {2.7f, 2.4f, 2.7f, seed & 2u ? PARQUET : TILES, seed & 1u ? WALLPAPER : WALL, WALL, seed};
    const opening side[1] = {{1.3f, 3.3f, 0.6f, 2.3f}};
    const opening* windows[4] = {NULL, side, NULL, NULL};
    const int counts[4] = {0, 1, 0, 0};
    const place shelf = place_at(-0.5f * width, r.y - 0.34f, 0, 0);
    set_daylight(s, -0.35f, 0.35f);
    set_indoors(s);
    add_room(s, &r, windows, counts);
    add_block(s, v(0, 0.30f, 0), v(width, 0.33f, step * (float)rows), 0.2f, WOOD, seed + 1u, shelf);
    for (int i = 0; i <= rows; i++)
        add_block(s, v(0, 0, step * (float)i), v(width, 0.30f, step * (float)i + 0.025f), 0.12f, WOOD, seed, shelf);
    for (int i = 0; i <= columns; i++) {
        const float x = width * (float)i / (float)columns;
        add_block(s, v(x - 0.014f, 0, 0), v(x + 0.014f, 0.30f, step * (float)rows + 0.025f), 0.15f, WOOD, seed, shelf);
    }
    for (int i = 0; i < columns * rows; i++) {
        const float cell_width = width / (float)columns - 0.03f,
                    x = 0.016f + width / (float)columns * (float)(i % columns),
                    z = step * (float)(i / columns) + 0.026f;
        const int kind = draw_int(s, 5);
        const float books = kind < 2 ? cell_width : kind < 4 ? draw(s, 0.35f, 0.6f) * cell_width : 0.0f;
        if (books > 0.0f) add_books(s, books, 0.23f, step - 0.05f, within(shelf, x, 0.03f, z, 0));
        for (float at = x + books + 0.14f; at < x + cell_width - 0.1f; at += 0.27f)
            add_trinket(s, draw(s, 0.19f, 0.27f), within(shelf, at, 0.14f, z, draw(s, -0.6f, 0.6f)));
    }
    for (int i = 0; i < 4; i++)
        add_trinket(
            s, draw(s, 0.26f, 0.34f),
            within(shelf, width * ((float)i + 0.5f) / 4.0f, 0.15f, step * (float)rows + 0.026f, draw(s, -0.5f, 0.5f)));
    const v3 foot = v(draw(s, 0.5f, width - 0.9f), -0.55f, 0), head = v(foot.x + 0.04f, -0.03f, 2.15f); // ladder
    for (int i = 0; i < 2; i++)
        add_tube(s, add(foot, v(0.38f * (float)i, 0, 0)), add(head, v(0.38f * (float)i, 0, 0)), 0.017f, 0.017f, 8, WOOD,
                 seed + 3u, shelf);
    for (int i = 1; i < 7; i++) {
        const v3 rung = mix(foot, head, (float)i / 7.0f);
        add_tube(s, rung, add(rung, v(0.38f, 0, 0)), 0.012f, 0.012f, 7, WOOD, seed + 3u, shelf);
    }
    add_standing_lamp(s, 1.65f, draw(s, 0.4f, 1.0f), place_at(-0.5f * width - 0.35f, r.y - 0.55f, 0, 0));
    add_lamp_bulb(s, v(0.3f, -0.9f, 2.5f), v(1.4f, 1.25f, 1.05f), 0.2f);
    add_potted_plant(s, 1.3f, place_at(0.5f * width + 0.35f, r.y - 0.4f, 0, 0));
    add_chair(s, seed + 64u, place_at(0.75f, r.y - 1.05f, 0, -0.7f));
    add_panel(s, v(0, 0.9f, 0.006f), v(1, 0, 0), v(0, 1, 0), 2.6f, 1.5f, RUG, seed, place_at(0, 0, 0, 0));
    add_sheet(s, v(r.x + 0.3f, -9, -0.02f), v(12, 0, 0), v(0, 18, 0), 1.0f, GRASS, seed, place_at(0, 0, 0, 0));
    set_forward(s, 0.8f, v(0, r.y - 0.2f, 1.1f), v(0, r.y - 2.75f, 1.25f), 0.55f);
}

static void build_street(world* s) {
    const uint32_t seed = draw_seed(s);
    const float half = draw(s, 3.2f, 4.4f), length = 30.0f;
    const place here = place_at(0, 0, 0, 0);
    set_daylight(s, -2.0f, 0.7f);
    add_sheet(s, v(-15, -half + 1.3f, 0), v(length, 0, 0), v(0, 2 * half - 2.6f, 0), 0.3f, seed & 1u ? ASPHALT : PAVING,
              seed, here);
    for (int i = 0; i < 2; i++) {
        const place side = place_at(0, 0, 0, i ? half_turn : 0.0f);
        add_block(s, v(-15, half - 1.3f, -0.1f), v(15, half + 0.5f, 0.12f), 0.35f, CONCRETE, seed, side);
        add_row_of_houses(s, length, 1, within(side, -15, half, 0.1f, 0));
        for (int k = 0; k < 4; k++) {
            const float x = -9.0f + 6.0f * (float)k + draw(s, -1.5f, 1.5f), y = half - 0.95f;
            switch (draw_int(s, 5)) {
                case 0: add_street_lamp(s, 3.4f, within(side, x, y, 0.12f, 0)); break;
                case 1: add_tree(s, draw(s, 3.6f, 4.8f), 1600, within(side, x, y, 0.12f, draw(s, 0, 6))); break;
                case 2: add_bicycle(s, within(side, x, half - 0.35f, 0.12f, draw(s, -0.08f, 0.08f))); break;
                case 3: add_bench(s, seed, within(side, x, half - 0.6f, 0.12f, half_turn)); break;
                default: add_chalkboard(s, within(side, x, y + 0.2f, 0.12f, draw(s, -0.4f, 0.4f)));
            }
            add_potted_plant(s, draw(s, 0.8f, 1.3f), within(side, x + 1.6f, half - 0.35f, 0.12f, 0));
            if (draw(s, 0, 1) < 0.6f)
                add_fruit_crate(s, within(side, x + 2.6f, half - 0.4f, 0.12f, draw(s, -0.2f, 0.2f)));
        }
        for (int k = 0; k < 8; k++) { // bollards
            const float x = -13.0f + 3.5f * (float)k;
            add_tube(s, v(x, half - 1.2f, 0.1f), v(x, half - 1.2f, 0.85f), 0.06f, 0.05f, 12, METAL, 4, side);
            add_ball(s, 0.07f, METAL, 4, within(side, x, half - 1.2f, 0.88f, 0));
        }
    }
    for (int k = 0; k < 5; k++) { // wires and lanterns across the street
        const float x = -11.0f + 5.0f * (float)k, z = draw(s, 4.2f, 5.6f);
        add_cable(s, v(x, -half, z), v(x + draw(s, -1, 1), half, z + draw(s, -0.4f, 0.4f)), 0.012f, 0.35f, METAL, here);
        add_cable(s, v(x + 0.5f, -half, z + 0.5f), v(x + 3.0f, half, z), 0.010f, 0.5f, METAL, here);
        add_ball(s, 0.13f, GLOW, seed, place_at(x, 0, z - 0.45f, 0));
    }
    add_row_of_houses(s, 2 * half + 10, 1, place_at(15.5f, half + 5, 0, -0.5f * half_turn));
    add_row_of_houses(s, 2 * half + 10, 0, place_at(-15.5f, -half - 5, 0, 0.5f * half_turn));
    set_walk(s, 0.8f, v(-8.5f, -0.3f, 1.65f), v(3.0f, 0.3f, 1.65f), 0.6f, 0.5f);
}

static void build_facade(world* s) {
    const uint32_t seed = draw_seed(s);
    const float width = draw(s, 5.6f, 7.0f);
    const place front = place_at(-0.5f * width, 0, 0.1f, 0), here = place_at(0, 0, 0, 0);
    set_daylight(s, -1.5f, 0.9f);
    add_sheet(s, v(-14, -14, 0), v(28, 0, 0), v(0, 12.4f, 0), 0.25f, seed & 1u ? PAVING : ASPHALT, seed, here);
    add_block(s, v(-14, -1.6f, -0.1f), v(14, 0.2f, 0.1f), 0.25f, CONCRETE, seed, here);
    add_house(s, width, 3, seed & 2u ? 1 : 0, front);
    add_house(s, 5.2f, 2 + (int)(seed >> 2 & 1u), 1, within(front, -5.2f, 0.15f, 0, 0));
    add_house(s, 5.2f, 2 + (int)(seed >> 3 & 1u), 0, within(front, width, -0.1f, 0, 0));
    add_bench(s, seed, place_at(-0.28f * width, -0.45f, 0.1f, half_turn));
    add_bicycle(s, place_at(0.25f * width, -0.4f, 0.1f, draw(s, -0.06f, 0.06f)));
    add_street_lamp(s, 3.5f, place_at(0.48f * width, -1.2f, 0.1f, 0));
    add_tree(s, draw(s, 3.4f, 4.4f), 1600, place_at(-0.62f * width, -1.1f, 0.1f, draw(s, 0, 6)));
    for (int i = 0; i < 4; i++)
        add_potted_plant(s, draw(s, 0.8f, 1.3f),
                         place_at(-3.2f + 2.1f * (float)i + draw(s, -0.3f, 0.3f), -0.4f, 0.1f, 0));
    add_chalkboard(s, place_at(draw(s, 0.3f, 1.0f), -1.1f, 0.1f, draw(s, -0.3f, 0.3f)));
    add_fruit_crate(s, place_at(-0.5f, -0.5f, 0.1f, 0.1f));
    for (int i = 0; i < 3; i++)
        add_cable(s, v(-8, -0.3f - 0.3f * (float)i, 4.2f + 0.7f * (float)i), v(8, -0.5f, 4.6f + 0.8f * (float)i),
                  0.012f, 0.25f, METAL, here);
    set_forward(s, 0.95f, v(0, 0, 2.2f), v(draw(s, -0.8f, 0.8f), -7.2f, 1.8f), 1.5f);
}

static void build_garden(world* s) {
    const uint32_t seed = draw_seed(s);
    const place here = place_at(0, 0, 0, 0);
    set_daylight(s, -1.0f, 1.2f);
    add_outdoors(s, 11.0f, GRASS, seed);
    for (int i = 0; i < 14; i++) { // a path of stones
        const float x = -4.6f + 0.72f * (float)i, shape[4] = {0.27f, 0.16f, 0.25f, (float)i};
        add_patch(s, patch_sphere, shape, 22, 12, GRANITE, seed,
                  place_at(x, -1.5f + 0.45f * sinf(1.1f * x), 0.0f, (float)i));
    }
    for (int i = 0; i < 4; i++) {
        const place side = place_at(0, 0, 0, 0.5f * half_turn * (float)i);
        if ((seed >> i) & 1u) add_hedge(s, 10.0f, 0.6f, draw(s, 1.1f, 1.9f), within(side, 0, 5.2f, 0, 0));
        else add_pickets(s, 10.0f, 1.2f, seed + (uint32_t)i, within(side, -5.0f, 5.2f, 0, 0));
        add_tree(s, draw(s, 3.2f, 4.6f), 1600, within(side, draw(s, -3.5f, 3.5f), 6.6f, 0, draw(s, 0, 6)));
    }
    for (int i = 0; i < 3; i++) {
        const float a = 0.4f + 2.1f * (float)i + draw(s, -0.2f, 0.2f);
        add_flowers(s, draw(s, 1.4f, 2.2f), 0.7f, 55,
                    place_at(2.0f * cosf(a), 2.0f * sinf(a), 0, a + 0.5f * half_turn));
    }
    add_lathe(s, profiles[5], 0.3f, 0.85f, 32, 32, MARBLE, seed, here); // bird bath
    add_lathe(s, profiles[2], 0.42f, 0.16f, 40, 24, MARBLE, seed, place_at(0, 0, 0.78f, 0));
    add_disc(s, 0.36f, 0.90f, MIRROR, 0, here);
    add_ball(s, 0.16f, CHROME, 1, place_at(-1.0f, 0.7f, 0.62f, 0)); // a gazing ball
    add_lathe(s, profiles[5], 0.15f, 0.48f, 20, 20, METAL, seed, place_at(-1.0f, 0.7f, 0, 0));
    add_bench(s, seed, place_at(0.2f, 3.5f, 0, half_turn));
    add_tree(s, 2.9f, 900, place_at(2.9f, 1.9f, 0, 1));
    for (int i = 0; i < 4; i++)
        add_potted_plant(s, draw(s, 0.9f, 1.5f),
                         place_at(1.5f * cosf(1.4f * (float)i + 0.8f), 1.4f * sinf(1.4f * (float)i + 0.8f), 0, 0));
    add_crown(s, v(0.5f, 0.45f, 0.42f), 700, 0.09f, draw_seed(s), 0.2f, place_at(-1.7f, -0.4f, 0.38f, 0));
    add_crown(s, v(0.4f, 0.4f, 0.35f), 500, 0.08f, draw_seed(s), 0.3f, place_at(1.2f, -0.7f, 0.3f, 0));
    for (int i = 0; i < 7; i++) { // bushes before the hedges
        const float a = 0.9f * (float)i + draw(s, -0.25f, 0.25f), size = draw(s, 0.35f, 0.65f);
        if (sinf(a) < -0.5f) continue; // where the camera is
        add_crown(s, v(size, size, 0.9f * size), 520, 0.08f, draw_seed(s), draw(s, -0.1f, 0.45f),
                  place_at(4.1f * cosf(a), 4.1f * sinf(a), 0.8f * size, 0));
    }
    const uint32_t grass = draw_seed(s) / 7u * 7u + 6u;
    for (int i = 0; i < 3000; i++) { // tufts
        const v3 at = v(draw(s, -4.5f, 4.5f), draw(s, -2.8f, 4.5f), 0);
        add_leaf(s, at, unit(add(draw_direction(s, 0.3f), v(0, 0, 0.7f))), draw(s, 0.05f, 0.13f), 0.012f, FOLIAGE,
                 grass << 16 | (uint32_t)i, here);
    }
    if (seed & 32u) set_orbit(s, 0.85f, v(0, 0.3f, 0.75f), 3.4f, 1.6f, -0.5f * half_turn + draw(s, -0.3f, 0.3f));
    else set_walk(s, 0.8f, v(-4.3f, -2.6f, 1.5f), v(2.2f, -2.3f, 1.5f), 0.25f, 0.3f), s->capture.start = 0.65f;
}

static void build_monument(world* s) {
    static const material grounds[3] = {PAVING, CONCRETE, GRAVEL}, stones[3] = {MARBLE, ASHLAR, GRANITE};
    const uint32_t seed = draw_seed(s);
    const material stone = stones[seed % 3u], figure = seed & 16u ? METAL : stones[(seed >> 5) % 3u];
    const place here = place_at(0, 0, 0, draw(s, -0.4f, 0.4f));
    float z = 0.0f;
    set_daylight(s, -1.2f, 1.2f);
    add_outdoors(s, 13.0f, grounds[(seed >> 3) % 3u], seed);
    for (int i = 0; i < 3; i++) {
        const float half = 1.75f - 0.3f * (float)i;
        add_block(s, v(-half, -half, z - 0.05f), v(half, half, z + 0.17f), 0.12f, ASHLAR, seed, here);
        z += 0.17f;
    }
    add_block(s, v(-0.72f, -0.72f, z), v(0.72f, 0.72f, z + 0.14f), 0.1f, stone, seed, here);
    add_block(s, v(-0.58f, -0.58f, z + 0.14f), v(0.58f, 0.58f, z + 1.2f), 0.1f, stone, seed, here);
    add_block(s, v(-0.7f, -0.7f, z + 1.2f), v(0.7f, 0.7f, z + 1.32f), 0.1f, stone, seed, here);
    for (int i = 0; i < 4; i++) {
        const float a = 0.5f * half_turn * (float)i;
        hang_panel(s, v(0.586f * cosf(a), 0.586f * sinf(a), z + 0.68f), a, 0.9f, i & 1 ? 0.34f : 0.7f,
                   i & 1 ? SIGN : PICTURE, seed + 3u * (uint32_t)i, here);
    }
    z += 1.32f;
    switch ((seed >> 8) % 4u) {
        case 0: // obelisk
            for (int i = 0; i < 4; i++) {
                const place side = within(here, 0, 0, z, 0.5f * half_turn * (float)i);
                const float a = 0.36f, b = 0.2f, h = 2.3f;
                const float shape[9] = {-a, -a, 0, 2 * a, 0, 0, 0, a - b, h};
                add_patch(s, patch_rectangle, shape, 10, 24, stone, seed, side);
                const float tip[9] = {-b - 0.16f, -b, h, 2 * b + 0.32f, 0, 0, 0, b + 0.16f, 0.3f};
                add_patch(s, patch_rectangle, tip, 6, 6, stone, seed, side);
            }
            break;
        case 1:
            add_patch(s, patch_knot, (const float[4]){0.8f, 0.17f, 2, 3}, 24, 200, figure, seed,
                      within(here, 0, 0, z, 0));
            break;
        case 2: { // a figure
            static const float robe[] = {9,     0.42f, 0,     0.45f, 0.05f, 0.36f, 0.5f, 0.27f, 0.95f, 0.31f,
                                         1.25f, 0.29f, 1.42f, 0.12f, 1.55f, 0.09f, 1.6f, 0.09f, 1.65f};
            add_lathe(s, robe, 0.45f, 1.65f, 44, 60, figure, seed, within(here, 0, 0, z, 0));
            const float head[4] = {0.17f, 1.2f, 0.1f, (float)(seed & 7u)};
            add_patch(s, patch_sphere, head, 32, 22, figure, seed, within(here, 0, 0, z + 1.82f, 0));
            const v3 hand = v(0.62f, 0.1f, z + 1.9f), elbow = v(0.46f, 0.16f, z + 1.25f);
            add_tube(s, v(0.24f, 0, z + 1.42f), elbow, 0.09f, 0.07f, 14, figure, seed, here);
            add_tube(s, elbow, hand, 0.07f, 0.05f, 14, figure, seed, here);
            add_lathe(s, profiles[5], 0.09f, 0.4f, 18, 18, figure, seed,
                      within(here, hand.x, hand.y, hand.z - 0.1f, 0));
            add_tube(s, v(-0.24f, 0, z + 1.42f), v(-0.42f, 0.2f, z + 0.95f), 0.09f, 0.06f, 14, figure, seed, here);
            add_ball(s, 0.13f, CHROME, 1, within(here, -0.42f, 0.26f, z + 0.88f, 0));
            break;
        }
        default: // a great vase with a plant
            add_lathe(s, profiles[0], 0.55f, 1.1f, 48, 48, figure == METAL ? GLASSY : figure, seed,
                      within(here, 0, 0, z, 0));
            add_crown(s, v(0.55f, 0.55f, 0.45f), 700, 0.13f, draw_seed(s), 0.25f, within(here, 0, 0, z + 1.35f, 0));
    }
    for (int i = 0; i < 8; i++) { // posts and chains
        const float a = 0.25f * half_turn * (float)i + 0.39f, b = a + 0.25f * half_turn;
        const v3 p = v(2.9f * cosf(a), 2.9f * sinf(a), 0.62f), q = v(2.9f * cosf(b), 2.9f * sinf(b), 0.62f);
        add_tube(s, v(p.x, p.y, 0), v(p.x, p.y, 0.7f), 0.06f, 0.045f, 12, METAL, seed, here);
        add_ball(s, 0.075f, METAL, seed, within(here, p.x, p.y, 0.74f, 0));
        add_cable(s, p, q, 0.014f, 0.2f, METAL, here);
    }
    for (int i = 0; i < 4; i++) {
        const float a = 0.5f * half_turn * (float)i + 0.8f;
        add_flowers(s, 1.5f, 0.6f, 45, within(here, 2.25f * cosf(a), 2.25f * sinf(a), 0, a + 0.5f * half_turn));
        add_bench(s, seed, within(here, 6.6f * cosf(a + 0.3f), 6.6f * sinf(a + 0.3f), 0, a + 0.3f + 0.5f * half_turn));
        add_street_lamp(s, 3.6f, within(here, 7.0f * cosf(a - 0.25f), 7.0f * sinf(a - 0.25f), 0, a));
        add_tree(s, draw(s, 4.0f, 5.5f), 1600, within(here, 8.4f * cosf(a), 8.4f * sinf(a), 0, a));
        const place side = place_at(0, 0, 0, 0.5f * half_turn * (float)i);
        add_row_of_houses(s, 24.0f, 1, within(side, -12, 12, 0, 0));
    }
    set_orbit(s, 0.85f, v(0, 0, 1.75f), 6.0f, 2.0f, -0.5f * half_turn + draw(s, -1, 1));
}

static void build_kitchen(world* s) {
    const uint32_t seed = draw_seed(s);
    const room_plan r = {2.2f, 2.0f, 2.6f, seed & 1u ? TILES : PARQUET, WALL, WALL, seed};
    const opening over[1] = {{1.55f, 2.85f, 1.15f, 2.15f}}, side[1] = {{1.0f, 2.4f, 0.9f, 2.2f}};
    const opening* windows[4] = {over, side, NULL, NULL};
    const int counts[4] = {1, 1, 0, 0};
    const place wall = wall_of(&r, NORTH);
    set_daylight(s, 0.7f, 0.5f);
    set_indoors(s);
    add_room(s, &r, windows, counts);
    const opening splash[3][1] = {
        {{0.05f, 1.5f, 0.9f, 1.45f}}, {{1.5f, 2.9f, 0.9f, 1.1f}}, {{2.9f, 4.35f, 0.9f, 1.45f}}};
    for (int i = 0; i < 3; i++) // tiles
        add_sheet(s, v(splash[i][0].x0, -0.01f, 0.9f), v(splash[i][0].x1 - splash[i][0].x0, 0, 0),
                  v(0, 0, splash[i][0].z1 - 0.9f), 0.1f, TILES, seed * 5u + 17u, wall);
    add_block(s, v(0, -0.62f, 0.08f), v(4.4f, 0, 0.86f), 0.3f, ENAMEL, seed, wall);
    add_block(s, v(0, -0.66f, 0.86f), v(4.4f, 0, 0.90f), 0.08f, seed & 2u ? MARBLE : WOOD, seed, wall);
    for (int i = 0; i < 7; i++) {
        const float x = 0.36f + 0.61f * (float)i;
        if (i % 3 == 1) {
            for (int k = 0; k < 3; k++) {
                add_panel(s, v(x, -0.625f, 0.22f + 0.25f * (float)k), v(1, 0, 0), v(0, 0, 1), 0.56f, 0.22f, SHUTTER,
                          seed + 64u, wall);
                add_tube(s, v(x - 0.07f, -0.65f, 0.25f + 0.25f * (float)k),
                         v(x + 0.07f, -0.65f, 0.25f + 0.25f * (float)k), 0.009f, 0.009f, 7, CHROME, 1, wall);
            }
        } else {
            add_panel(s, v(x, -0.625f, 0.47f), v(1, 0, 0), v(0, 0, 1), 0.56f, 0.72f, DOOR, seed + 64u, wall);
        }
    }
    for (int i = 0; i < 2; i++) { // shelves left and right of the window
        const float x0 = i ? 2.98f : 0.1f, x1 = i ? 4.3f : 1.42f;
        for (int k = 0; k < 2; k++) {
            const float z = 1.56f + 0.38f * (float)k;
            add_block(s, v(x0, -0.26f, z), v(x1, 0, z + 0.025f), 0.12f, WOOD, seed + 1u, wall);
            for (float x = x0 + 0.15f; x < x1 - 0.05f; x += 0.235f)
                add_trinket(s, draw(s, 0.18f, 0.26f), within(wall, x, -0.13f, z + 0.026f, draw(s, -0.6f, 0.6f)));
        }
        add_tube(s, v(x0, -0.05f, 1.42f), v(x1, -0.05f, 1.42f), 0.008f, 0.008f, 7, CHROME, 1, wall);
        for (int k = 0; k < 5; k++) { // ladles and pans on hooks
            const float x = x0 + 0.16f + 0.25f * (float)k, l = draw(s, 0.2f, 0.28f);
            add_tube(s, v(x, -0.07f, 1.42f), v(x, -0.07f, 1.42f - l), 0.006f, 0.006f, 6, CHROME, 1, wall);
            if (k % 2)
                add_cushion(s, v(0.075f, 0.012f, 0.075f), 0.9f, METAL, seed, within(wall, x, -0.06f, 1.36f - l, 0));
            else add_cushion(s, v(0.035f, 0.03f, 0.035f), 1.0f, CHROME, seed, within(wall, x, -0.07f, 1.40f - l, 0));
        }
    }
    add_block(s, v(3.1f, -0.58f, 0.90f), v(3.75f, -0.08f, 0.92f), 0.1f, METAL, 5, wall); // stove with pots
    for (int i = 0; i < 2; i++) {
        const place pot = within(wall, 3.25f + 0.33f * (float)i, -0.33f, 0.92f, 0.8f * (float)i);
        add_tube(s, v(0, 0, 0), v(0, 0, 0.15f), 0.125f, 0.13f, 32, i ? ENAMEL : CHROME, seed, pot);
        add_lathe(s, profiles[7], 0.13f, 0.05f, 28, 12, i ? ENAMEL : CHROME, seed, within(pot, 0, 0, 0.15f, 0));
        add_tube(s, v(0.12f, 0, 0.12f), v(0.30f, 0, 0.13f), 0.012f, 0.012f, 8, METAL, 1, pot);
    }
    add_block(s, v(1.85f, -0.55f, 0.895f), v(2.5f, -0.12f, 0.905f), 0.1f, CHROME, 1, wall); // sink
    add_tube(s, v(2.17f, -0.08f, 0.9f), v(2.17f, -0.08f, 1.18f), 0.016f, 0.014f, 10, CHROME, 1, wall);
    add_tube(s, v(2.17f, -0.08f, 1.18f), v(2.17f, -0.28f, 1.14f), 0.014f, 0.012f, 10, CHROME, 1, wall);
    scatter(s, 5, 1.5f, 0.5f, 0.22f, within(wall, 0.9f, -0.33f, 0.9f, 0));
    scatter(s, 3, 0.55f, 0.45f, 0.18f, within(wall, 4.05f, -0.33f, 0.9f, 0));
    scatter(s, 3, 1.2f, 0.16f, 0.14f, within(wall, 2.2f, 0.1f, 1.15f, 0));
    add_table(s, 1.3f, 0.7f, 0.74f, seed, place_at(draw(s, -0.4f, 0.4f), 0.45f, 0, draw(s, -0.1f, 0.1f)));
    scatter(s, 5, 1.1f, 0.5f, 0.2f, place_at(0, 0.45f, 0.741f, 0));
    add_chair(s, seed, place_at(-1.0f, 0.3f, 0, -1.2f));
    add_pendant(s, v(0, 0.35f, 1.95f), r.height, 0.9f);
    add_lamp_bulb(s, v(0, -0.8f, 2.4f), v(1.1f, 1.0f, 0.85f), 0.2f);
    add_hedge(s, 8.0f, 0.6f, 1.8f, place_at(0, r.y + 3.0f, 0, 0));
    add_tree(s, 4.0f, 700, place_at(1.0f, r.y + 4.2f, 0, 0));
    add_sheet(s, v(-9, r.y + 0.3f, -0.02f), v(18, 0, 0), v(0, 12, 0), 1.0f, GRASS, seed, place_at(0, 0, 0, 0));
    set_forward(s, 0.75f, v(0, r.y - 0.4f, 1.15f), v(0, -1.15f, 1.5f), 0.6f);
}

static void build_gallery(world* s) {
    static const material stones[4] = {MARBLE, GRANITE, METAL, CHROME};
    const uint32_t seed = draw_seed(s);
    const room_plan r = {draw(s, 2.6f, 3.4f), 6.5f, 3.6f, seed & 1u ? MARBLE : PARQUET, WALL, WALL, seed & ~1u};
    const int counts[4] = {0, 0, 0, 0};
    set_daylight(s, 0.4f, 0.5f);
    set_indoors(s);
    add_room(s, &r, (const opening**)no_windows, counts);
    for (int side = 0; side < 4; side++) {
        const place wall = wall_of(&r, side);
        const float length = wall_length(&r, side);
        for (float x = 0.8f; x < length - 1.2f;) {
            const float width = draw(s, 0.7f, 1.7f), height = draw(s, 0.7f, 1.4f);
            if (x + width > length - 0.3f) break;
            hang_panel(s, v(x + 0.5f * width, -0.04f, 1.62f), -0.5f * half_turn, width, height,
                       draw(s, 0, 1) < 0.1f ? MIRROR : PICTURE, draw_seed(s), wall);
            add_block(s, v(x - 0.02f, -0.038f, 1.6f - 0.5f * height), v(x + width + 0.02f, 0, 1.64f + 0.5f * height),
                      0.4f, WOOD, 2, wall);
            add_panel(s, v(x + width + 0.16f, -0.01f, 1.2f), v(1, 0, 0), v(0, 0, 1), 0.16f, 0.11f, CHALK, draw_seed(s),
                      wall);
            for (int k = 0; k < 2; k++)
                add_tube(s, v(x + width * (0.2f + 0.6f * (float)k), -0.02f, 1.62f + 0.5f * height),
                         v(x + width * (0.2f + 0.6f * (float)k), -0.02f, 3.1f), 0.003f, 0.003f, 4, METAL, 1, wall);
            x += width + draw(s, 0.5f, 0.9f);
        }
        add_tube(s, v(0, -0.03f, 3.1f), v(length, -0.03f, 3.1f), 0.012f, 0.012f, 6, METAL, 1, wall);
    }
    for (int i = 0; i < 6; i++) { // sculptures on plinths on both sides of the way
        const float x = (i & 1 ? 1.0f : -1.0f) * (r.x - 1.15f), y = -3.6f + 1.5f * (float)i, top = draw(s, 0.7f, 1.05f);
        const place at = place_at(x, y, 0, draw(s, 0, 3));
        const material stone = stones[draw_int(s, 4)];
        const float size = draw(s, 0.5f, 0.7f);
        add_block(s, v(-0.24f, -0.24f, 0), v(0.24f, 0.24f, top), 0.15f, draw(s, 0, 1) < 0.5f ? ENAMEL : MARBLE, WHITE,
                  at);
        switch (draw_int(s, 5)) {
            case 0:
                add_patch(s, patch_knot, (const float[4]){0.42f * size, 0.11f * size, 2, 3}, 18, 130, stone, seed,
                          within(at, 0, 0, top, 0));
                break;
            case 1:
                add_patch(s, patch_knot, (const float[4]){0.42f * size, 0.09f * size, 3, 5}, 16, 180, stone, seed,
                          within(at, 0, 0, top, 0));
                break;
            case 2:
                add_lathe(s, profiles[0], 0.3f * size, 0.9f * size, 40, 40, GLASSY, seed + (uint32_t)i,
                          within(at, 0, 0, top, 0));
                break;
            case 3: {
                const float lump[4] = {0.4f * size, 1.1f, 1.0f, (float)i + 3.0f};
                add_patch(s, patch_sphere, lump, 50, 34, stone, seed, within(at, 0, 0, top + 0.4f * size, 0));
                break;
            }
            default:
                for (int k = 0; k < 4; k++)
                    add_ball(s, (0.24f - 0.05f * (float)k) * size, k & 1 ? CHROME : ENAMEL, seed + (uint32_t)k,
                             within(at, 0, 0, top + size * (0.24f + 0.4f * (float)k - 0.045f * (float)(k * k)), 0));
        }
        for (int k = 0; k < 2; k++) { // a rope in front
            const float px = (i & 1 ? -0.55f : 0.55f), py = (k ? 0.45f : -0.45f);
            add_tube(s, v(x + px, y + py, 0), v(x + px, y + py, 0.8f), 0.016f, 0.016f, 8, CHROME, 1,
                     place_at(0, 0, 0, 0));
            add_ball(s, 0.03f, CHROME, 1, place_at(x + px, y + py, 0.8f, 0));
            if (k)
                add_cable(s, v(x + px, y - 0.45f, 0.76f), v(x + px, y + 0.45f, 0.76f), 0.016f, 0.12f, ENAMEL,
                          place_at(0, 0, 0, 0));
        }
    }
    for (int i = 0; i < 4; i++) { // skylights
        const float y = -4.8f + 3.2f * (float)i;
        add_block(s, v(-0.9f, y - 0.7f, r.height - 0.03f), v(0.9f, y + 0.7f, r.height), 0.2f, GLOW, 3,
                  place_at(0, 0, 0, 0));
    }
    for (int i = 0; i < 3; i++)
        add_lamp_bulb(s, v(0, -4.0f + 4.0f * (float)i, r.height - 0.4f), v(2.2f, 2.1f, 1.95f), 0.3f);
    add_bench(s, seed, place_at(0, 4.6f, 0, half_turn));
    add_potted_plant(s, 1.7f, place_at(-r.x + 0.6f, 5.8f, 0, 0));
    add_potted_plant(s, 1.7f, place_at(r.x - 0.6f, 5.8f, 0, 0));
    set_walk(s, 0.75f, v(0, -5.6f, 1.55f), v(0, 2.4f, 1.55f), 0.3f, 0.55f);
}

static void build_market(world* s) {
    const uint32_t seed = draw_seed(s);
    const place here = place_at(0, 0, 0, 0);
    const float half = draw(s, 1.7f, 2.1f);
    set_daylight(s, -1.4f, 0.9f);
    add_outdoors(s, 10.0f, seed & 1u ? PAVING : CONCRETE, seed);
    for (int i = 0; i < 4; i++) { // posts, and an awning over the stall
        const float x = i & 1 ? half : -half, y = i & 2 ? 0.9f : -0.75f;
        add_tube(s, v(x, y, 0), v(x, y, i & 2 ? 2.75f : 2.25f), 0.03f, 0.03f, 8, WOOD, seed | 256u, here);
    }
    const uint32_t stripes = fabric_of(seed, 1);
    add_sheet(s, v(-half - 0.25f, -1.1f, 2.16f), v(2 * half + 0.5f, 0, 0), v(0, 2.1f, 0.62f), 0.12f, FABRIC, stripes,
              here);
    add_sheet(s, v(-half - 0.25f, -1.105f, 1.96f), v(2 * half + 0.5f, 0, 0), v(0, 0, 0.2f), 0.12f, FABRIC, stripes,
              here);
    for (int row = 0; row < 3; row++) { // crates on steps
        const float z = 0.55f + 0.24f * (float)row, y = -0.45f + 0.43f * (float)row;
        add_block(s, v(-half + 0.05f, y - 0.21f, z - 0.04f), v(half - 0.05f, y + 0.21f, z), 0.2f, WOOD, seed, here);
        add_block(s, v(-half + 0.05f, y + 0.19f, 0), v(half - 0.05f, y + 0.21f, z), 0.3f, WOOD, seed, here);
        for (float x = -half + 0.35f; x < half - 0.2f; x += 0.58f) {
            const float kind = draw(s, 0, 1);
            const place at = place_at(x, y, z + 0.002f, draw(s, -0.04f, 0.04f));
            if (kind < 0.72f || row == 0) add_fruit_crate(s, at);
            else
                for (int k = 0; k < 2; k++)
                    add_trinket(s, draw(s, 0.22f, 0.32f), within(at, -0.13f + 0.28f * (float)k, 0, 0, draw(s, -1, 1)));
            if (draw(s, 0, 1) < 0.5f) { // price
                add_tube(s, v(0, -0.17f, 0.1f), v(0, -0.17f, 0.3f), 0.004f, 0.004f, 4, WOOD, 1, at);
                add_panel(s, v(0, -0.176f, 0.33f), v(1, 0, 0), v(0, 0, 1), 0.17f, 0.11f, CHALK, draw_seed(s), at);
            }
        }
    }
    add_sheet(s, v(-half + 0.05f, -0.665f, 0.04f), v(2 * half - 0.1f, 0, 0), v(0, 0, 0.5f), 0.1f, FABRIC, draw_seed(s),
              here);
    add_panel(s, v(0, -0.78f, 1.84f), v(1, 0, 0), v(0, 0, 1), 1.5f, 0.3f, SIGN, seed, here);
    for (int i = 0; i < 3; i++) {
        const float x = -half + (0.5f + (float)i) * 2.0f * half / 3.0f;
        add_tube(s, v(x, -0.2f, 1.95f), v(x, -0.2f, 2.4f), 0.004f, 0.004f, 4, METAL, 1, here);
        add_ball(s, 0.055f, GLOW, 1, place_at(x, -0.2f, 1.92f, 0));
        for (int k = 0; k < 3; k++)
            add_crown(s, v(0.06f, 0.06f, 0.13f), 40, 0.09f, seed, 0.3f,
                      place_at(x + 0.35f + 0.12f * (float)k, -0.6f, 1.9f, 0));
    }
    for (int i = 0; i < 3; i++) {
        add_fruit_crate(s, place_at(-half + 0.5f + 1.3f * (float)i, -1.05f, 0, draw(s, -0.2f, 0.2f)));
        add_cushion(s, v(0.2f, 0.17f, 0.27f), 0.7f, FABRIC, fabric_of(seed + (uint32_t)i, 4),
                    place_at(half + 0.45f, -0.6f + 0.5f * (float)i, 0.27f, 0));
    }
    add_chalkboard(s, place_at(-half - 0.55f, -0.9f, 0, draw(s, -0.3f, 0.3f)));
    add_bicycle(s, place_at(half + 1.3f, 0.6f, 0, draw(s, -0.5f, 0.5f)));
    add_potted_plant(s, 1.5f, place_at(-half - 0.7f, 0.3f, 0, 0));
    add_street_lamp(s, 3.4f, place_at(-half - 1.6f, 1.8f, 0, 0));
    add_tree(s, 4.5f, 1000, place_at(half + 2.4f, 2.6f, 0, 0));
    add_row_of_houses(s, 22.0f, 1, place_at(-11, 4.5f, 0, 0));
    for (int i = 0; i < 4; i++)
        add_cable(s, v(-8, 0.5f + 0.8f * (float)i, 3.6f), v(8, 0.8f * (float)i, 4.2f), 0.012f, 0.4f, METAL, here);
    set_orbit(s, 0.85f, v(0, 0, 1.05f), 3.3f, 1.65f, -0.5f * half_turn + draw(s, -0.15f, 0.15f));
}

typedef struct scene_layout {
    const char *name, *capture, *about;
    void (*build)(world*);
} scene_layout;

static const scene_layout layouts[] = {
    {"courtyard", "orbit", "a laid table between brick walls, pots and rocks; the seed moves leaves and cameras only",
     build_courtyard},
    {"still_life", "orbit", "a table with small things, chairs; in a room or in a garden", build_still_life},
    {"living_room", "orbit", "sofa, rug, bookcase, pictures and mirrors, a lamp, sun through curtained windows",
     build_living_room},
    {"corridor", "walk", "doors, posters, pipes and cables along a passage with a lacquered or tiled floor",
     build_corridor},
    {"bookshelf", "forward", "a wall of books and small things, a ladder", build_bookshelf},
    {"street", "walk", "houses with shops, shutters and balconies, wires overhead", build_street},
    {"facade", "forward", "the front of a house, a bench and a bicycle before it", build_facade},
    {"garden", "orbit or walk", "hedges, trees, flower beds, a bird bath and a mirror ball", build_garden},
    {"monument", "orbit", "a statue on steps, chains around it, houses and trees behind", build_monument},
    {"kitchen", "forward", "counter, tiles, steel pots and ladles, a window over the sink", build_kitchen},
    {"gallery", "walk", "paintings, sculptures of stone and chrome, ropes, a polished floor", build_gallery},
    {"market", "orbit", "a stall with crates of fruit under a striped awning, price tags", build_market},
};
enum { LAYOUTS = sizeof layouts / sizeof *layouts };

#endif // SCENE_LAYOUTS_H
