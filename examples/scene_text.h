// scene_text.h - lettering for signs, books and posters. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_TEXT_H
#define SCENE_TEXT_H

#include "scene_math.h"

/* Letters are sets of these strokes, on a grid 1 wide and 2 high:
       +--0--+
       5\ | /1      8, 9, 10: the upper diagonals and the line between them
       +-6+7-+
       4/ | \2      11, 12, 13: the lower ones
       +--3--+       */
enum { STROKES = 14 };
static const float strokes[STROKES][4] = {{0, 2, 1, 2},       {1, 1, 1, 2},       {1, 0, 1, 1},    {0, 0, 1, 0},
                                          {0, 0, 0, 1},       {0, 1, 0, 2},       {0, 1, 0.5f, 1}, {0.5f, 1, 1, 1},
                                          {0, 2, 0.5f, 1},    {0.5f, 1, 0.5f, 2}, {0.5f, 1, 1, 2}, {0, 0, 0.5f, 1},
                                          {0.5f, 0, 0.5f, 1}, {0.5f, 1, 1, 0}};

static const uint16_t letters[26] = {0x00f7, 0x128f, 0x0039, 0x120f, 0x00f9, 0x0071, 0x00bd, 0x00f6, 0x1209,
                                     0x001e, 0x2470, 0x0038, 0x0536, 0x2136, 0x003f, 0x00f3, 0x203f, 0x20f3,
                                     0x00ed, 0x1201, 0x003e, 0x0c30, 0x2836, 0x2d00, 0x1500, 0x0c09};
static const uint16_t digits[10] = {0x0c3f, 0x0406, 0x00db, 0x008f, 0x00e6, 0x00ed, 0x00fd, 0x1401, 0x00ff, 0x00ef};

// Ink at (x,y) of a word that starts at x = 0 on the line y = 0: each letter is 1 wide, 2 high and 1.5 from the next.
// `weight` is half the width of a stroke, `width` that of a pixel.
static float ink_of(const char* word, float x, float y, float weight, float width) {
    const int at = floor_int((x + 0.25f) / 1.5f);
    if (at < 0 || (size_t)at >= strlen(word) || y < -0.3f || y > 2.3f) return 0.0f;
    const char c = word[at];
    const unsigned set = c >= 'A' && c <= 'Z' ? letters[c - 'A'] : c >= '0' && c <= '9' ? digits[c - '0'] : 0u;
    float nearest = 9.0f;
    x -= 1.5f * (float)at;
    for (int i = 0; i < STROKES; i++) {
        if (!(set >> i & 1u)) continue;
        const float* s = strokes[i];
        const float ex = s[2] - s[0], ey = s[3] - s[1], px = x - s[0], py = y - s[1];
        const float t = clampf((px * ex + py * ey) / (ex * ex + ey * ey), 0, 1), dx = px - t * ex, dy = py - t * ey;
        nearest = minf(nearest, dx * dx + dy * dy);
    }
    const float soft = maxf(0.5f * width, 0.01f);
    return step_between(weight + soft, weight - soft, sqrtf(nearest)) * minf(1.0f, 2.0f * weight / maxf(width, 1e-6f));
}

static float length_of(const char* word) { return 1.5f * (float)strlen(word) - 0.5f; }

// The same for a word in a box centred on (0,0), as large as fits.
static float ink_in_box(const char* word, float x, float y, float box_width, float box_height, float weight,
                        float width) {
    const float scale = minf(box_width / length_of(word), 0.5f * box_height);
    return ink_of(word, x / scale + 0.5f * length_of(word), y / scale + 1.0f, weight, width / scale);
}

#endif // SCENE_TEXT_H
