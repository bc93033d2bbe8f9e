// scene_math.h - vectors and hashes. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_MATH_H
#define SCENE_MATH_H

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct v3 { float x, y, z; } v3;

static inline float maxf(float a, float b) { return a > b ? a : b; } // fmaxf has to handle NaN and is a call
static inline float minf(float a, float b) { return a < b ? a : b; }

static inline v3 v(float x, float y, float z) { const v3 r = {x, y, z}; return r; }
static inline v3 add(v3 a, v3 b) { return v(a.x + b.x, a.y + b.y, a.z + b.z); }
static inline v3 sub(v3 a, v3 b) { return v(a.x - b.x, a.y - b.y, a.z - b.z); }
static inline v3 mul(v3 a, float s) { return v(a.x * s, a.y * s, a.z * s); }
static inline v3 times(v3 a, v3 b) { return v(a.x * b.x, a.y * b.y, a.z * b.z); }
static inline float dot(v3 a, v3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline v3 cross(v3 a, v3 b) { return v(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
static inline v3 unit(v3 a) { return mul(a, 1.0f / sqrtf(maxf(dot(a, a), 1e-20f))); }
static inline v3 mix(v3 a, v3 b, float t) { return add(mul(a, 1.0f - t), mul(b, t)); }
static inline float clampf(float x, float lo, float hi) { return x < lo ? lo : x > hi ? hi : x; }
static inline float step_between(float lo, float hi, float x) { // smoothstep
    const float t = clampf((x - lo) / (hi - lo), 0.0f, 1.0f);
    return t * t * (3.0f - 2.0f * t);
}
static inline v3 rotate_z(v3 a, float angle) {
    const float c = cosf(angle), s = sinf(angle);
    return v(c * a.x - s * a.y, s * a.x + c * a.y, a.z);
}

static inline uint32_t hash3(int32_t x, int32_t y, int32_t z) {
    uint32_t h = (uint32_t)x * 0x9e3779b1u ^ (uint32_t)y * 0x85ebca77u ^ (uint32_t)z * 0xc2b2ae3du;
    h = (h ^ (h >> 15)) * 0x2c1b3c6du;
    h = (h ^ (h >> 12)) * 0x297a2d39u;
    return h ^ (h >> 15);
}
static inline float random3(int32_t x, int32_t y, int32_t z) { return (float)(hash3(x, y, z) >> 8) / 16777216.0f; }
static inline int32_t floor_int(float x) { return (int32_t)x - (x < (float)(int32_t)x); }

#endif // SCENE_MATH_H
