// scene_noise.h - noise and cells, the stuff of procedural textures. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_NOISE_H
#define SCENE_NOISE_H

#include "scene_math.h"

enum { LATTICE = 64 }; // period of the noise
static float lattice[LATTICE * LATTICE * LATTICE];
static void make_lattice(void) {
    for (int32_t i = 0; i < LATTICE * LATTICE * LATTICE; i++) lattice[i] = random3(i, 3, 9);
}

static float noise(v3 p) { // value noise, [0,1]
    const int32_t x = floor_int(p.x), y = floor_int(p.y), z = floor_int(p.z), m = LATTICE - 1;
    const float fx = p.x - (float)x, fy = p.y - (float)y, fz = p.z - (float)z;
    const float u = fx * fx * (3 - 2 * fx), q = fy * fy * (3 - 2 * fy), t = fz * fz * (3 - 2 * fz);
    const int32_t x0 = x & m, x1 = (x + 1) & m, y0 = LATTICE * (y & m), y1 = LATTICE * ((y + 1) & m);
    const float *lo = lattice + LATTICE * LATTICE * (z & m), *hi = lattice + LATTICE * LATTICE * ((z + 1) & m);
    const float a = lo[y0 + x0] + u * (lo[y0 + x1] - lo[y0 + x0]), b = lo[y1 + x0] + u * (lo[y1 + x1] - lo[y1 + x0]);
    const float c = hi[y0 + x0] + u * (hi[y0 + x1] - hi[y0 + x0]), d = hi[y1 + x0] + u * (hi[y1 + x1] - hi[y1 + x0]);
    const float below = a + q * (b - a), above = c + q * (d - c);
    return below + t * (above - below);
}
// `width` here and below: size of a pixel in units of the noise. Detail finer than a pixel is replaced by its mean, so that
// a place has the same texture in near and far photos.
static float soft_noise(v3 p, float width) {
    return width >= 1.0f ? 0.5f : width <= 0.5f ? noise(p) : 0.5f + (2.0f - 2.0f * width) * (noise(p) - 0.5f);
}
static float fbm(v3 p, int octaves, float width) { // [0,1], mean 0.5
    float sum = 0.0f, weight = 0.5f, total = 0.0f;
    for (int i = 0; i < octaves; i++, weight *= 0.55f, width *= 2.03f) {
        sum += weight * soft_noise(p, width);
        total += weight;
        p = add(mul(p, 2.03f), v(17.3f, 5.1f, 9.7f));
    }
    return sum / total;
}

typedef struct voronoi_cell { float edge; uint32_t id; } voronoi_cell; // edge: distance to the cell's border; id: hash

static voronoi_cell voronoi(float x, float y, int32_t salt) {
    const int32_t cx = floor_int(x), cy = floor_int(y);
    float best = 1e9f, second = 1e9f;
    voronoi_cell out = {0.0f, 0};
    for (int32_t j = cy - 1; j <= cy + 1; j++)
        for (int32_t i = cx - 1; i <= cx + 1; i++) {
            const float dx = (float)i + 0.1f + 0.8f * random3(i, j, salt) - x;
            const float dy = (float)j + 0.1f + 0.8f * random3(i, j, salt + 1) - y;
            const float d = sqrtf(dx * dx + dy * dy);
            if (d < best) {
                second = best;
                best = d;
                out.id = hash3(i, j, salt + 2);
            } else if (d < second) {
                second = d;
            }
        }
    out.edge = second - best;
    return out;
}
// One of four random numbers in [0,1] from a hash.
static float part(uint32_t id, int which) { return (float)(id >> (8 * which) & 255u) / 255.0f; }

#endif // SCENE_NOISE_H
