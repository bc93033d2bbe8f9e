// scene_layouts.h - the scenes. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_LAYOUTS_H
#define SCENE_LAYOUTS_H

#include "scene_geometry.h"

static void build_world(world* s) {
    const place here = {{0, 0, 0}, 0};
    add_patch(s, patch_ground, NULL, 150, 150, PAVING, 0, here);
    static const float walls[4][9] = {{-5, 5, -0.1f, 10, 0, 0, 0, 0, 2.5f}, {5, 5, -0.1f, 0, -10, 0, 0, 0, 2.1f},
                                      {5, -5, -0.1f, -10, 0, 0, 0, 0, 2.5f}, {-5, -5, -0.1f, 0, 10, 0, 0, 0, 2.1f}};
    for (int i = 0; i < 4; i++) {
        const float top = walls[i][2] + walls[i][8];
        add_patch(s, patch_rectangle, walls[i], 60, 16, i & 1 ? PLASTER : BRICK, (uint32_t)i, here);
        if (i & 1)
            add_box(s, v(walls[i][0] - 0.18f, -5.2f, top), v(walls[i][0] + 0.18f, 5.2f, top + 0.09f), 12, COPING, 0,
                    here);
        else add_box(s, v(-5.2f, walls[i][1] - 0.18f, top), v(5.2f, walls[i][1] + 0.18f, top + 0.09f), 12, COPING, 0, here);
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

#endif // SCENE_LAYOUTS_H
