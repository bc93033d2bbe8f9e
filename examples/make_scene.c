/* make_scene - a small courtyard, ray traced, written as if photographed and reconstructed by COLMAP
   gcc -O2 -std=c11 -fopenmp -DGSFIXER_IMPLEMENTATION -DGSF_USE_EMBREE -I. examples/make_scene.c -o make_scene -lembree3 -lm

       make_scene OUT [--views 40] [--width 320] [--height 240] [--seed 1] [--points 10000] [--noise 0.5] [--arc 150]
           [--drift 0]

   --noise: standard deviation of feature positions in pixels; --arc: angle in degrees of the camera's path around the
   table; --drift: the exposure rises and falls by so many stops from photo to photo. `--views 12 --width 96 --height 64`
   takes less than two seconds.
       OUT/images/frame_001.png ...
       OUT/sparse/0/{cameras,images,points3D}.bin   points as feature matching would find them: in textured areas,
                                                    triangulated from noisy pixels, matched in only some of the views
                                                    that can see them, a few of them outliers
       OUT/truth/depth_001.npy ...                  float32 (height,width) camera depth at pixel centres, 0 = sky
       OUT/truth/normal_001.npy ...                 float32 (height,width,3) unit normals of the triangles there, as
                                                    flat as the depth is, in the axes of the COLMAP model, towards the
                                                    camera; 0 = sky
       OUT/truth/visibility.bin                     see write_truth
       OUT/truth/scene.json                         the options it was made with
   OUT must be a new folder, an empty one or one written by make_scene, so that no other files are replaced.

       make_scene SCENE --render CAMERAS.json --out PICTURES

   renders an existing scene from other cameras (the format of `gsfix path`) like additional photos of it, with the same
   light and sensor noise. With the scene's own cameras, it reproduces the scene's photos.
       PICTURES/00000.png ...        in the order of the cameras
       PICTURES/depth/00000.npy, PICTURES/normal/00000.npy ...  as in OUT/truth
   PICTURES must be a new or an empty folder. */
#ifndef _POSIX_C_SOURCE
#define _POSIX_C_SOURCE 200809L // mkdir
#endif
#include "gsfixer_splat.h"

#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

typedef struct make_scene_options {
    int views, width, height, points;
    double noise, arc;
    uint64_t seed;
    double drift;
} make_scene_options;

static const make_scene_options make_scene_defaults = {40, 320, 240, 10000, 0.5, 150.0, 1, 0.0};

#ifndef GSF_USE_EMBREE

static int make_scene(gsf_context* ctx, const make_scene_options* options, const char* folder) {
    (void)ctx, (void)options, (void)folder;
    fprintf(stderr, "make_scene: built without Embree, which traces the rays (compile with GSF_USE_EMBREE)\n");
    return 1;
}

#ifndef MAKE_SCENE_NO_MAIN
static int render_scene(gsf_context* ctx, const char* folder, const char* cameras, const char* out) {
    (void)cameras, (void)out;
    return make_scene(ctx, &make_scene_defaults, folder); // prints the error
}
#endif

#else

#if defined(__has_include)
#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif
#else
#include <embree3/rtcore.h>
#endif

// ---- vectors and noise ---------------------------------------------------------

typedef struct v3 { float x, y, z; } v3;

static float maxf(float a, float b) { return a > b ? a : b; } // fmaxf has to handle NaN and is a call
static float minf(float a, float b) { return a < b ? a : b; }

static v3 v(float x, float y, float z) { const v3 r = {x, y, z}; return r; }
static v3 add(v3 a, v3 b) { return v(a.x + b.x, a.y + b.y, a.z + b.z); }
static v3 sub(v3 a, v3 b) { return v(a.x - b.x, a.y - b.y, a.z - b.z); }
static v3 mul(v3 a, float s) { return v(a.x * s, a.y * s, a.z * s); }
static v3 times(v3 a, v3 b) { return v(a.x * b.x, a.y * b.y, a.z * b.z); }
static float dot(v3 a, v3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static v3 cross(v3 a, v3 b) { return v(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
static v3 unit(v3 a) { return mul(a, 1.0f / sqrtf(maxf(dot(a, a), 1e-20f))); }
static v3 mix(v3 a, v3 b, float t) { return add(mul(a, 1.0f - t), mul(b, t)); }
static float clampf(float x, float lo, float hi) { return x < lo ? lo : x > hi ? hi : x; }
static float step_between(float lo, float hi, float x) { // smoothstep
    const float t = clampf((x - lo) / (hi - lo), 0.0f, 1.0f);
    return t * t * (3.0f - 2.0f * t);
}
static v3 rotate_z(v3 a, float angle) {
    const float c = cosf(angle), s = sinf(angle);
    return v(c * a.x - s * a.y, s * a.x + c * a.y, a.z);
}

static uint32_t hash3(int32_t x, int32_t y, int32_t z) {
    uint32_t h = (uint32_t)x * 0x9e3779b1u ^ (uint32_t)y * 0x85ebca77u ^ (uint32_t)z * 0xc2b2ae3du;
    h = (h ^ (h >> 15)) * 0x2c1b3c6du;
    h = (h ^ (h >> 12)) * 0x297a2d39u;
    return h ^ (h >> 15);
}
static float random3(int32_t x, int32_t y, int32_t z) { return (float)(hash3(x, y, z) >> 8) / 16777216.0f; }
static int32_t floor_int(float x) { return (int32_t)x - (x < (float)(int32_t)x); }

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

typedef struct cell { float edge; uint32_t id; } cell; // edge: distance to the cell's border; id: hash

static cell voronoi(float x, float y, int32_t salt) {
    const int32_t cx = floor_int(x), cy = floor_int(y);
    float best = 1e9f, second = 1e9f;
    cell out = {0.0f, 0};
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

// ---- materials -----------------------------------------------------------------

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

// ---- geometry ------------------------------------------------------------------

typedef struct vertex { v3 at, normal, local, light; } vertex; // light: diffuse light from sky and surroundings
typedef struct triangle { uint32_t v[3]; } triangle;
typedef struct surface { material m; uint32_t seed; float yaw; } surface;

typedef struct world {
    vertex* vertices;
    triangle* triangles;
    surface* surfaces; // per triangle
    size_t vertex_count, vertex_room, triangle_count, triangle_room;
    RTCDevice device;
    RTCScene scene;
    uint64_t seed;
    float pixel_angle; // of the photos, radians
    int failed;        // out of memory
} world;

typedef struct place { v3 at; float yaw; } place;
typedef v3 (*patch_fn)(float u, float w, const float* shape); // u, w in [0,1] -> local position

static void* grown(void* array, size_t* room, size_t needed, size_t size, int* failed) {
    if (needed <= *room) return array;
    *room = 2 * needed + 1024;
    void* fresh = realloc(array, *room * size);
    if (!fresh) *failed = 1;
    return fresh ? fresh : array;
}

// Adds a patch as a grid of nu x nw cells. Normals are finite differences and point along d/du x d/dw.
static void add_patch(world* s, patch_fn fn, const float* shape, int nu, int nw, material m, uint32_t seed, place where) {
    const size_t first = s->vertex_count, points = (size_t)(nu + 1) * (size_t)(nw + 1);
    s->vertices = (vertex*)grown(s->vertices, &s->vertex_room, first + points, sizeof(vertex), &s->failed);
    const size_t cells = s->triangle_count + 2 * (size_t)nu * (size_t)nw;
    size_t room = s->triangle_room;
    s->triangles = (triangle*)grown(s->triangles, &room, cells, sizeof(triangle), &s->failed);
    s->surfaces = (surface*)grown(s->surfaces, &s->triangle_room, cells, sizeof(surface), &s->failed);
    if (s->failed) return;
    for (int j = 0; j <= nw; j++)
        for (int i = 0; i <= nu; i++) {
            const float u = (float)i / (float)nu, w = (float)j / (float)nw, e = 1e-3f;
            const float u0 = maxf(u - e, 0), u1 = minf(u + e, 1), w0 = maxf(w - e, 0), w1 = minf(w + e, 1);
            vertex* out = s->vertices + s->vertex_count++;
            out->local = fn(u, w, shape);
            v3 n = cross(sub(fn(u1, w, shape), fn(u0, w, shape)), sub(fn(u, w1, shape), fn(u, w0, shape)));
            if (dot(n, n) < 1e-16f) n = cross(sub(fn(u1, 0.5f, shape), fn(u0, 0.5f, shape)), v(0, 0, 1)); // pole
            if (dot(n, n) < 1e-16f) n = v(0, 0, w < 0.5f ? -1.0f : 1.0f);
            out->normal = rotate_z(unit(n), where.yaw);
            out->at = add(rotate_z(out->local, where.yaw), where.at);
            out->light = v(0, 0, 0);
        }
    for (int j = 0; j < nw; j++)
        for (int i = 0; i < nu; i++) {
            const uint32_t a = (uint32_t)(first + (size_t)j * (size_t)(nu + 1) + (size_t)i), b = a + (uint32_t)nu + 1;
            const triangle t0 = {{a, a + 1, b}}, t1 = {{a + 1, b + 1, b}};
            const surface kind = {m, seed, where.yaw};
            s->surfaces[s->triangle_count] = s->surfaces[s->triangle_count + 1] = kind;
            s->triangles[s->triangle_count++] = t0;
            s->triangles[s->triangle_count++] = t1;
        }
}

static v3 patch_ground(float u, float w, const float* shape) { // denser in the middle
    (void)shape;
    const float a = 2 * u - 1, b = 2 * w - 1;
    const v3 p = v(5.2f * (0.45f * a + 0.55f * a * a * a), 5.2f * (0.45f * b + 0.55f * b * b * b), 0);
    return v(p.x, p.y, 0.05f * (fbm(mul(p, 0.9f), 3, 0) - 0.5f));
}
static v3 patch_rectangle(float u, float w, const float* s) { // corner, edge, edge
    return v(s[0] + u * s[3] + w * s[6], s[1] + u * s[4] + w * s[7], s[2] + u * s[5] + w * s[8]);
}
static v3 patch_cloth(float u, float w, const float* s) { // hangs over the ends of a table of length s[0]
    const float x = (2 * u - 1) * (0.5f * s[0] + 0.16f), over = maxf(fabsf(x) - 0.5f * s[0] - 0.006f, 0.0f);
    const float y = (w - 0.5f) * 0.5f;
    const float wave = 0.012f * sinf(23.0f * y) * minf(over * 10.0f, 1.0f);
    return v((x < 0 ? -1.0f : 1.0f) * (fabsf(x) - over + minf(over, 0.01f) + wave), y, 0.004f - maxf(over - 0.01f, 0.0f));
}
static v3 patch_sphere(float u, float w, const float* s) { // radius, squash, lumps, seed
    const float a = 6.2831853f * u, b = 3.1415927f * (w - 0.5f);
    const v3 d = v(cosf(a) * cosf(b), sinf(a) * cosf(b), sinf(b));
    const float r = s[0] * (1.0f + s[2] * (fbm(add(mul(d, 1.6f), v(s[3], 0, 0)), 4, 0) - 0.5f));
    return v(d.x * r, d.y * r, d.z * r * s[1]);
}
static v3 patch_apple(float u, float w, const float* s) {
    const float a = 6.2831853f * u, b = 3.1415927f * w;
    const float r = s[0] * (0.62f + 0.42f * sinf(b)),
                z = -s[0] * cosf(b) * (0.72f + 0.2f * sinf(b)) * (1.0f - 0.35f * expf(-9.0f * (3.1415927f - b)));
    return v(cosf(a) * r * sinf(b), sinf(a) * r * sinf(b), z);
}
static v3 patch_torus(float u, float w, const float* s) {
    const float a = 6.2831853f * u, b = 6.2831853f * w, r = s[1] * (1.0f + 0.08f * sinf(26.0f * a + 3.0f * b));
    return v(cosf(a) * (s[0] + r * cosf(b)), sinf(a) * (s[0] + r * cosf(b)), r * sinf(b));
}
static v3 patch_lathe(float u, float w, const float* s) { // a smooth profile through s[0] pairs of (radius, height)
    const int n = (int)s[0];
    const float t = w * (float)(n - 1);
    const int i = t >= (float)(n - 1) ? n - 2 : (int)t;
    const float f = t - (float)i;
    float value[2];
    for (int k = 0; k < 2; k++) { // Catmull-Rom
        const float* q = s + 1 + k;
        const float a = q[2 * (i > 0 ? i - 1 : 0)], b = q[2 * i], c = q[2 * i + 2], d = q[2 * (i + 2 < n ? i + 2 : n - 1)];
        value[k] = b + 0.5f * f * (c - a + f * (2 * a - 5 * b + 4 * c - d + f * (3 * (b - c) + d - a)));
    }
    return v(cosf(6.2831853f * u) * value[0], sinf(6.2831853f * u) * value[0], value[1]);
}
static v3 patch_leaf(float u, float w, const float* s) { // base, direction*length, side*width, curl
    const float width = sinf(3.1415927f * clampf(0.06f + 0.94f * u, 0, 1)) * (2 * w - 1),
                curl = s[9] * u * u - 0.25f * width * width * s[9];
    return v(s[0] + u * s[3] + width * s[6], s[1] + u * s[4] + width * s[7], s[2] + u * s[5] + width * s[8] - curl);
}

static void add_box(world* s, v3 lo, v3 hi, int cells, material m, uint32_t seed, place where) {
    const v3 d = sub(hi, lo);
    const float faces[6][9] = {{lo.x, lo.y, hi.z, d.x, 0, 0, 0, d.y, 0}, {lo.x, lo.y, lo.z, 0, d.y, 0, d.x, 0, 0},
                               {lo.x, lo.y, lo.z, d.x, 0, 0, 0, 0, d.z}, {lo.x, hi.y, lo.z, 0, 0, d.z, d.x, 0, 0},
                               {lo.x, lo.y, lo.z, 0, 0, d.z, 0, d.y, 0}, {hi.x, lo.y, lo.z, 0, d.y, 0, 0, 0, d.z}};
    for (int f = 0; f < 6; f++) add_patch(s, patch_rectangle, faces[f], cells, cells, m, seed, where);
}

static float pick(world* s, uint64_t stream, uint64_t index, float lo, float hi) {
    return lo + (hi - lo) * (float)gsf_draw_uniform(s->seed, stream, index);
}

static void add_bush(world* s, place where, float radius, float height, int leaves, uint64_t stream) {
    for (int i = 0; i < leaves; i++) {
        const uint64_t k = 8 * (uint64_t)i;
        const float a = pick(s, stream, k, 0, 6.2831853f), e = asinf(pick(s, stream, k + 1, -0.25f, 1.0f));
        const v3 out = v(cosf(a) * cosf(e), sinf(a) * cosf(e), sinf(e));
        const float r = sqrtf(pick(s, stream, k + 2, 0.25f, 1.0f)), length = pick(s, stream, k + 3, 0.09f, 0.16f);
        const v3 base = v(out.x * radius * r, out.y * radius * r, height * (0.45f + 0.5f * out.z * r));
        const v3 dir = unit(add(out, v(pick(s, stream, k + 4, -0.6f, 0.6f), pick(s, stream, k + 5, -0.6f, 0.6f), 0.2f)));
        const v3 side = mul(unit(cross(dir, add(out, v(0.1f, 0, 0.8f)))), 0.32f * length);
        const v3 tip = mul(dir, length);
        const float shape[10] = {base.x, base.y, base.z, tip.x, tip.y, tip.z, side.x, side.y, side.z, 0.35f * length};
        add_patch(s, patch_leaf, shape, 4, 2, LEAF, (uint32_t)(i + 1000 * (int)stream), where);
    }
}

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

// ---- rays and light ------------------------------------------------------------

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

static struct RTCRay make_ray(v3 from, v3 d, float near, float far) {
    struct RTCRay ray;
    memset(&ray, 0, sizeof ray);
    ray.org_x = from.x, ray.org_y = from.y, ray.org_z = from.z;
    ray.dir_x = d.x, ray.dir_y = d.y, ray.dir_z = d.z;
    ray.tnear = near, ray.tfar = far;
    ray.mask = 0xffffffffu;
    return ray;
}

static int blocked(const world* s, v3 from, v3 d, float near, float far) {
    struct RTCRay ray = make_ray(from, d, near, far);
#if RTC_VERSION_MAJOR < 4
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded1(s->scene, &context, &ray);
#else
    rtcOccluded1(s->scene, &ray, NULL);
#endif
    return ray.tfar < 0.0f;
}

static int trace(const world* s, v3 from, v3 d, float near, hit* out) {
    struct RTCRayHit r;
    memset(&r, 0, sizeof r);
    r.ray = make_ray(from, d, near, INFINITY);
    r.hit.geomID = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR < 4
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(s->scene, &context, &r);
#else
    rtcIntersect1(s->scene, &r, NULL);
#endif
    if (r.hit.geomID == RTC_INVALID_GEOMETRY_ID) return 0;
    const triangle* t = s->triangles + r.hit.primID;
    const vertex *a = s->vertices + t->v[0], *b = s->vertices + t->v[1], *c = s->vertices + t->v[2];
    const float u = r.hit.u, w = r.hit.v, o = 1.0f - u - w;
    out->what = s->surfaces + r.hit.primID;
    out->t = r.ray.tfar;
    out->face = v(r.hit.Ng_x, r.hit.Ng_y, r.hit.Ng_z);
    out->at = add(from, mul(d, r.ray.tfar));
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

// ---- photos --------------------------------------------------------------------

typedef struct photo_job {
    const world* s;
    gsf_camera camera;
    uint64_t view;
    uint8_t* pixels; // (height,width,3)
    float* depth;    // (height,width)
    float* normal;   // (height,width,3)
    float exposure;  // factor
} photo_job;

// Between -drift/2 and drift/2 stops, about 17 photos per period.
static float exposure_of(const make_scene_options* o, uint64_t view) {
    return exp2f(0.5f * (float)o->drift * sinf(0.37f * (float)(view % 4096) + 0.5f));
}

static v3 eye_of(const gsf_camera* camera) {
    double c[3];
    gsf_get_camera_center(camera, c);
    return v((float)c[0], (float)c[1], (float)c[2]);
}
static v3 ray_through(const gsf_camera* camera, double x, double y, float* z) { // z: camera depth per unit of ray length
    const double *m = camera->w2c, a = (x - camera->cx) / camera->fx, b = (y - camera->cy) / camera->fy;
    const v3 d = v((float)(m[0] * a + m[1] * b + m[2]), (float)(m[4] * a + m[5] * b + m[6]),
                   (float)(m[8] * a + m[9] * b + m[10]));
    *z = 1.0f / sqrtf(dot(d, d));
    return unit(d);
}

static float film(float x) { // Narkowicz's fit of the ACES curve, then sRGB encoding
    x *= 0.50f;
    x = clampf(x * (2.51f * x + 0.03f) / (x * (2.43f * x + 0.59f) + 0.14f), 0, 1);
    return x <= 0.0031308f ? 12.92f * x : 1.055f * powf(x, 1.0f / 2.4f) - 0.055f;
}

static void photo_row(void* arg, size_t row, int32_t worker) {
    (void)worker;
    enum { SAMPLES = 4 };
    static const float jitter[SAMPLES][2] = {{0.375f, 0.125f}, {0.875f, 0.375f}, {0.125f, 0.625f}, {0.625f, 0.875f}};
    const photo_job* job = (const photo_job*)arg;
    const v3 eye = eye_of(&job->camera);
    const int width = job->camera.width, height = job->camera.height;
    for (int x = 0; x < width; x++) {
        const size_t pixel = row * (size_t)width + (size_t)x;
        v3 sum = v(0, 0, 0);
        float z;
        hit h;
        v3 d = ray_through(&job->camera, x + 0.5, (double)row + 0.5, &z);
        const int found = trace(job->s, eye, d, 0.01f, &h);
        const v3 face = found ? unit(dot(h.face, d) > 0.0f ? mul(h.face, -1.0f) : h.face) : v(0, 0, 0);
        const float normal[3] = {face.x, face.y, face.z};
        job->depth[pixel] = found ? h.t * z : 0.0f;
        memcpy(job->normal + 3 * pixel, normal, sizeof normal);
        for (int k = 0; k < SAMPLES; k++) {
            const int32_t at = (int32_t)(4 * pixel) + k;
            d = ray_through(&job->camera, (double)x + (double)jitter[k][0], (double)row + (double)jitter[k][1], &z);
            v3 c = sky(d);
            if (trace(job->s, eye, d, 0.01f, &h)) {
                const float r1 =
                    ((float)k + random3(at, 1, (int32_t)job->view)) / SAMPLES;  // one sample per ring of the sun's disc
                c = shade(job->s, &h, d, r1, random3((int32_t)pixel, 2, (int32_t)job->view) + 0.381966f * (float)k);
                c = mix(c, v(0.55f, 0.62f, 0.70f), 0.012f * h.t); // a little haze
            }
            sum = add(sum, v(minf(c.x, 4), minf(c.y, 4), minf(c.z, 4)));
        }
        const float px = 2.0f * ((float)x + 0.5f) / (float)width - 1.0f,
                    py = 2.0f * ((float)row + 0.5f) / (float)height - 1.0f;
        sum = mul(sum, (1.0f - 0.11f * (px * px + py * py)) / SAMPLES); // vignetting
        const float c[3] = {film(job->exposure * sum.x), film(job->exposure * sum.y), film(job->exposure * sum.z)};
        for (size_t k = 0; k < 3; k++) { // sensor noise
            const float grain = 1.1f * (float)gsf_draw_normal(job->s->seed, 100 + job->view, 3 * pixel + k);
            job->pixels[3 * pixel + k] = (uint8_t)clampf(255.0f * c[k] + grain + 0.5f, 0, 255);
        }
    }
}

// A handheld camera carried around the table: distance, height, aim and roll vary.
static gsf_camera camera_of(world* s, const make_scene_options* o, int view) {
    gsf_camera c;
    memset(&c, 0, sizeof c);
    const float t = ((float)view + 0.5f) / (float)o->views - 0.5f,
                step = (float)(o->arc * 3.14159265 / 180.0) / (float)o->views;
    const uint64_t k = 16 * (uint64_t)view;
    const float angle = -1.40f + (float)(o->arc * 3.14159265 / 180.0) * t + pick(s, 1, k, -0.3f, 0.3f) * step;
    const float distance = 2.25f + 0.18f * sinf(9.0f * t) + pick(s, 1, k + 1, -0.12f, 0.12f);
    const float height = 1.50f + 0.22f * sinf(14.0f * t + 1.0f) + pick(s, 1, k + 2, -0.09f, 0.09f);
    const v3 eye = v(distance * cosf(angle), distance * sinf(angle), height);
    const v3 aim = v(pick(s, 1, k + 3, -0.08f, 0.08f), pick(s, 1, k + 4, -0.08f, 0.08f), pick(s, 1, k + 5, 0.58f, 0.70f));
    const v3 forward = unit(sub(aim, eye)), level = unit(cross(forward, v(0, 0, 1)));
    const float roll = pick(s, 1, k + 6, -0.03f, 0.03f);
    const v3 flat_down = cross(forward, level);
    const v3 right = unit(add(mul(level, cosf(roll)), mul(flat_down, sinf(roll)))), down = cross(forward, right);
    const v3 axes[3] = {right, down, forward};
    for (int r = 0; r < 3; r++) { // only as orthonormal as floats; Gram-Schmidt in double follows
        c.w2c[r] = (double)axes[r].x, c.w2c[4 + r] = (double)axes[r].y, c.w2c[8 + r] = (double)axes[r].z;
    }
    double* m = c.w2c;
    for (int r = 0; r < 3; r++) { // Gram-Schmidt on the rows
        for (int q = 0; q < r; q++) {
            const double along = m[r] * m[q] + m[4 + r] * m[4 + q] + m[8 + r] * m[8 + q];
            for (int i = 0; i < 12; i += 4) m[i + r] -= along * m[i + q];
        }
        const double size = sqrt(m[r] * m[r] + m[4 + r] * m[4 + r] + m[8 + r] * m[8 + r]);
        for (int i = 0; i < 12; i += 4) m[i + r] /= size;
        m[12 + r] = -(m[r] * (double)eye.x + m[4 + r] * (double)eye.y + m[8 + r] * (double)eye.z);
    }
    m[15] = 1.0;
    c.width = o->width;
    c.height = o->height;
    c.fx = c.fy = 0.9 * o->width;
    c.cx = 0.5 * o->width;
    c.cy = 0.5 * o->height;
    return c;
}

// ---- points --------------------------------------------------------------------

enum { TRUTH_VISIBLE = 1, TRUTH_IN_FRAME = 2 };

typedef struct cloud {
    gsf_scene scene;
    uint8_t* truth;   // (point_count,view_count)
    uint8_t* outlier; // (point_count)
} cloud;

// Whether a view sees a point: TRUTH_* flags.
static uint8_t truth_of(const world* s, const gsf_camera* camera, v3 at) {
    const double p[3] = {(double)at.x, (double)at.y, (double)at.z};
    double x, y, z;
    if (!gsf_project_point(camera, p, &x, &y, &z) || x < 0 || y < 0 || x >= camera->width || y >= camera->height) return 0;
    const v3 eye = eye_of(camera), d = sub(at, eye);
    const float distance = sqrtf(dot(d, d));
    return TRUTH_IN_FRAME | (blocked(s, eye, mul(d, 1.0f / distance), 0.01f, distance - 4e-3f) ? 0 : TRUTH_VISIBLE);
}

// Triangulates a point: least squares over the rays of its noisy observations. Returns 0 if the rays are nearly parallel.
static int triangulate(const gsf_scene* scene, const uint32_t* views, const double (*seen)[2], size_t count,
                       double out[3]) {
    double a[3][3] = {{0}}, b[3] = {0};
    for (size_t i = 0; i < count; i++) {
        const gsf_camera* camera = &scene->views[views[i]].camera;
        const double *m = camera->w2c,
                     q[3] = {(seen[i][0] - camera->cx) / camera->fx, (seen[i][1] - camera->cy) / camera->fy, 1.0};
        double d[3], c[3];
        const double size = sqrt(q[0] * q[0] + q[1] * q[1] + 1.0);
        for (int k = 0; k < 3; k++) d[k] = (m[4 * k] * q[0] + m[4 * k + 1] * q[1] + m[4 * k + 2]) / size;
        gsf_get_camera_center(camera, c);
        for (int r = 0; r < 3; r++)
            for (int k = 0; k < 3; k++) {
                const double w = (r == k) - d[r] * d[k];
                a[r][k] += w;
                b[r] += w * c[k];
            }
    }
    const double minor[3] = {a[1][1] * a[2][2] - a[1][2] * a[2][1], a[1][2] * a[2][0] - a[1][0] * a[2][2],
                             a[1][0] * a[2][1] - a[1][1] * a[2][0]};
    const double det = a[0][0] * minor[0] + a[0][1] * minor[1] + a[0][2] * minor[2];
    if (det < 1e-6) return 0;
    for (int k = 0; k < 3; k++) { // Cramer
        double t[3][3];
        memcpy(t, a, sizeof t);
        for (int r = 0; r < 3; r++) t[r][k] = b[r];
        out[k] = (t[0][0] * (t[1][1] * t[2][2] - t[1][2] * t[2][1]) - t[0][1] * (t[1][0] * t[2][2] - t[1][2] * t[2][0]) +
                  t[0][2] * (t[1][0] * t[2][1] - t[1][1] * t[2][0])) / det;
    }
    return 1;
}

static float texture_at(const uint8_t* pixels, int width, int x, int y) { // smaller eigenvalue of the structure tensor
    float xx = 1e-6f, yy = 1e-6f, xy = 0;
    for (int j = y - 1; j <= y + 1; j++)
        for (int i = x - 1; i <= x + 1; i++) {
            const uint8_t* p = pixels + 3 * ((size_t)j * (size_t)width + (size_t)i);
            const float gx = (float)p[4] - (float)p[-2], gy = (float)p[3 * width + 1] - (float)p[1 - 3 * width];
            xx += gx * gx, yy += gy * gy, xy += gx * gy;
        }
    return 0.5f * (xx + yy - sqrtf((xx - yy) * (xx - yy) + 4 * xy * xy));
}

// Tries one candidate: takes a pixel of a view, preferably at a corner, traces its ray, and decides which views see the
// point and which detect it. Returns the length of its track, less than 2 if the candidate is rejected.
static size_t find_point(const world* s, const make_scene_options* o, const cloud* c, uint8_t* const* photos, uint64_t try_,
                         uint32_t* track, double (*seen)[2], double at[3], uint8_t* truth, uint8_t* color, int* outlier) {
    const gsf_scene* scene = &c->scene;
    const uint64_t k = (uint64_t)try_ * 512;
    const uint32_t anchor = (uint32_t)(gsf_draw_bits(s->seed, 2, k) % (uint64_t)o->views);
    const gsf_camera* camera = &scene->views[anchor].camera;
    const double x = 2.0 + gsf_draw_uniform(s->seed, 2, k + 1) * (o->width - 4.0),
                 y = 2.0 + gsf_draw_uniform(s->seed, 2, k + 2) * (o->height - 4.0);
    const uint8_t* pixel = photos[anchor] + 3 * ((size_t)y * (size_t)o->width + (size_t)x);
    const float corner = texture_at(photos[anchor], o->width, (int)x, (int)y);
    if (gsf_draw_uniform(s->seed, 2, k + 3) > fmin(1.0, 0.004 + corner / 9000.0)) return 0;
    float z;
    hit h;
    const v3 eye = eye_of(camera), d = ray_through(camera, x, y, &z);
    if (!trace(s, eye, d, 0.01f, &h)) return 0;
    // A corner in the image that is really an occlusion edge is rarely matched in another view.
    for (int i = 0; i < 4; i++) {
        hit near;
        const v3 side = ray_through(camera, x + (i & 1 ? 3.0 : -3.0), y + (i & 2 ? 3.0 : -3.0), &z);
        const int jump = !trace(s, eye, side, 0.01f, &near) || fabsf(near.t - h.t) > 0.06f * h.t;
        if (jump && gsf_draw_uniform(s->seed, 2, k + 7) < 0.9) return 0;
    }
    *outlier = gsf_draw_uniform(s->seed, 2, k + 4) < 0.012;
    if (*outlier) h.at = add(eye, mul(d, h.t * (float)exp((gsf_draw_uniform(s->seed, 2, k + 5) - 0.5) * 1.2)));
    memcpy(color, pixel, 3);
    size_t length = 0;
    int wrong_left = 1 + (gsf_draw_uniform(s->seed, 2, k + 6) < 0.3); // further views of this outlier: 1, sometimes 2
    float widest = 0.0f; // largest angle between the anchor's ray and another view's
    for (int i = 0; i < o->views; i++) {
        const gsf_camera* other = &scene->views[i].camera;
        const uint64_t j = k + 8 + 4 * (uint64_t)(i % 120);
        truth[i] = truth_of(s, other, h.at);
        const v3 from = unit(sub(h.at, eye_of(other)));
        const float angle = acosf(clampf(dot(from, d), -1, 1)), facing = fabsf(dot(from, h.normal));
        double chance = 0.85 * exp(-(double)(angle * angle) / 0.30) * (double)step_between(0.08f, 0.35f, facing);
        int found = (truth[i] & TRUTH_VISIBLE) && gsf_draw_uniform(s->seed, 3, j + (uint64_t)i) < chance;
        if (*outlier) found = (truth[i] & TRUTH_IN_FRAME) && angle > 0.04f && angle < 0.25f && wrong_left-- > 0;
        if ((uint32_t)i == anchor) found = 1;
        if (!found) continue;
        const double p[3] = {(double)h.at.x, (double)h.at.y, (double)h.at.z};
        double u, w, depth;
        if (!gsf_project_point(other, p, &u, &w, &depth)) continue;
        track[length] = (uint32_t)i;
        seen[length][0] = u + o->noise * gsf_draw_normal(s->seed, 4, 2 * (k + (uint64_t)i));
        seen[length++][1] = w + o->noise * gsf_draw_normal(s->seed, 4, 2 * (k + (uint64_t)i) + 1);
        widest = maxf(widest, angle);
    }
    if (length < 2 || widest < 0.026f || !triangulate(scene, track, (const double(*)[2])seen, length, at))
        return 0;                         // 0.026 rad: 1.5 degrees
    for (size_t i = 0; i < length; i++) { // COLMAP's limit on the reprojection error: 4 pixels
        double u, w, depth;
        if (!gsf_project_point(&scene->views[track[i]].camera, at, &u, &w, &depth) ||
            hypot(u - seen[i][0], w - seen[i][1]) > 4.0)
            return 0;
    }
    return length;
}

static int find_points(gsf_context* ctx, const world* s, const make_scene_options* o, uint8_t* const* photos, cloud* c) {
    gsf_scene* scene = &c->scene;
    const size_t views = (size_t)o->views, wanted = (size_t)o->points;
    scene->points = (double*)gsf_alloc(ctx, wanted, 3 * sizeof(double));
    scene->colors = (uint8_t*)gsf_alloc(ctx, wanted, 3);
    scene->point_ids = (uint64_t*)gsf_alloc(ctx, wanted, sizeof(uint64_t));
    scene->track_begin = (size_t*)gsf_alloc_zeroed(ctx, wanted + 1, sizeof(size_t));
    scene->track_views = (uint32_t*)gsf_alloc(ctx, wanted * views, sizeof(uint32_t));
    c->truth = (uint8_t*)gsf_alloc(ctx, wanted, views);
    c->outlier = (uint8_t*)gsf_alloc_zeroed(ctx, wanted, 1);
    double(*seen)[2] = (double(*)[2])gsf_alloc(ctx, views, sizeof *seen);
    if (!scene->points || !scene->colors || !scene->point_ids || !scene->track_begin || !scene->track_views ||
        !c->truth || !c->outlier || !seen) {
        gsf_free(ctx, seen);
        return 0;
    }
    for (uint64_t i = 0; scene->point_count < wanted && i < 4000u * (uint64_t)wanted; i++) {
        const size_t n = scene->point_count, begin = scene->track_begin[n];
        int outlier = 0;
        const size_t length = find_point(s, o, c, photos, i, scene->track_views + begin, seen, scene->points + 3 * n,
                                         c->truth + n * views, scene->colors + 3 * n, &outlier);
        if (length < 2) continue;
        c->outlier[n] = (uint8_t)outlier;
        scene->point_ids[n] = n + 1;
        scene->track_begin[n + 1] = begin + length;
        scene->point_count++;
    }
    gsf_free(ctx, seen);
    return 1;
}

// ---- files ---------------------------------------------------------------------

static int make_folder(const char* folder, const char* below) {
    char path[2048];
    snprintf(path, sizeof path, "%s%s", folder, below);
    if (mkdir(path, 0777) == 0 || errno == EEXIST) return 1;
    fprintf(stderr, "make_scene: %s: %s\n", path, strerror(errno));
    return 0;
}

// Writes an array of shape (height,width) or, with more than one channel, (height,width,channels).
static gsf_result write_npy(gsf_context* ctx, const char* path, const float* values, int width, int height, int channels) {
    gsf_buffer out;
    char head[128], last[16] = "";
    memset(&out, 0, sizeof out);
    if (channels > 1) snprintf(last, sizeof last, ", %d", channels);
    snprintf(head, sizeof head, "{'descr': '<f4', 'fortran_order': False, 'shape': (%d, %d%s), }", height, width, last);
    gsf_append_bytes(ctx, &out, "\x93NUMPY\x01\x00\x76\x00", 10); // version 1.0, header of 118 bytes
    gsf_append_text(ctx, &out, "%-117s\n", head);
    gsf_append_bytes(ctx, &out, (const char*)values, (size_t)width * (size_t)height * (size_t)channels * sizeof(float));
    const gsf_result result = out.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, out.data, out.size);
    gsf_destroy_buffer(ctx, &out);
    return result;
}

/* OUT/truth/visibility.bin, little-endian:
       char magic[8] "GSFTRUTH" | u64 points | u64 views
       u8 seen[points][views]   bit 0: visible, not occluded; bit 1: inside the frame (bit 0 implies bit 1)
       u8 outlier[points]       1: a wrong match
   Points are in the order of points3D.bin, views in the order of their names. Visibility is that of the exact surface
   point, before noise; for an outlier, that of the position of the wrong match. */
static gsf_result write_truth(gsf_context* ctx, const char* path, const cloud* c) {
    gsf_buffer out;
    memset(&out, 0, sizeof out);
    const uint64_t sizes[2] = {c->scene.point_count, c->scene.view_count};
    gsf_append_bytes(ctx, &out, "GSFTRUTH", 8);
    gsf_append_bytes(ctx, &out, (const char*)sizes, sizeof sizes);
    gsf_append_bytes(ctx, &out, (const char*)c->truth, c->scene.point_count * c->scene.view_count);
    gsf_append_bytes(ctx, &out, (const char*)c->outlier, c->scene.point_count);
    const gsf_result result = out.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, out.data, out.size);
    gsf_destroy_buffer(ctx, &out);
    return result;
}

// OUT/truth/scene.json: all options that determine the scene.
static gsf_result write_options(gsf_context* ctx, const char* path, const make_scene_options* o) {
    char text[320], drift[48] = "";
    if (o->drift != 0.0) snprintf(drift, sizeof drift, ",\"drift\":%.17g", o->drift);
    const int size = snprintf(text, sizeof text, "{\"views\":%d,\"width\":%d,\"height\":%d,\"points\":%d,\"noise\":%.17g,"
                              "\"arc\":%.17g,\"seed\":%llu%s}\n", o->views, o->width, o->height, o->points, o->noise, o->arc,
                              (unsigned long long)o->seed, drift);
    return gsf_write_file(ctx, path, text, (size_t)size);
}

// ---- scene ---------------------------------------------------------------------

static int start_world(gsf_context* ctx, world* s, const make_scene_options* o) {
    const int bake_rays = o->width * o->height < 20000 ? 8 : 32; // the difference is invisible in small photos
    s->seed = o->seed;
    s->pixel_angle = 1.0f / (0.9f * (float)o->width);
    make_lattice();
    build_world(s);
    s->device = rtcNewDevice("threads=1,set_affinity=0");
    if (s->failed || !s->device) {
        fprintf(stderr, "make_scene: %s\n", s->failed ? "out of memory" : "Embree cannot create a device");
        return 0;
    }
    RTCGeometry mesh = rtcNewGeometry(s->device, RTC_GEOMETRY_TYPE_TRIANGLE);
    s->scene = rtcNewScene(s->device);
    rtcSetSharedGeometryBuffer(mesh, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, s->vertices, 0, sizeof(vertex),
                               s->vertex_count);
    rtcSetSharedGeometryBuffer(mesh, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, s->triangles, 0, sizeof(triangle),
                               s->triangle_count);
    rtcCommitGeometry(mesh);
    rtcAttachGeometry(s->scene, mesh);
    rtcReleaseGeometry(mesh);
    rtcCommitScene(s->scene);
    if (rtcGetDeviceError(s->device) != RTC_ERROR_NONE) {
        fprintf(stderr, "make_scene: Embree cannot build the scene\n");
        s->scene = NULL; // leaked on purpose: releasing it could wait for a TBB task that never ran
        return 0;
    }
    bake_job bake = {s, bake_rays};
    ctx->parallel.for_fn(ctx->parallel.user, (s->vertex_count + BAKE_CHUNK - 1) / BAKE_CHUNK, bake_chunk, &bake);
    return 1;
}

static void end_world(world* s) {
    if (s->scene) rtcReleaseScene(s->scene);
    if (s->device) rtcReleaseDevice(s->device);
    free(s->vertices);
    free(s->triangles);
    free(s->surfaces);
}

static int take_photos(gsf_context* ctx, world* s, const make_scene_options* o, const char* folder, gsf_scene* scene,
                       uint8_t** photos) {
    const size_t pixels = (size_t)o->width * (size_t)o->height;
    float *depth = (float*)gsf_alloc(ctx, pixels, sizeof(float)),
          *normal = (float*)gsf_alloc(ctx, pixels, 3 * sizeof(float));
    int ok = depth && normal;
    for (int i = 0; ok && i < o->views; i++) {
        char path[2048];
        gsf_scene_view* view = scene->views + i;
        view->image_id = (uint32_t)i + 1;
        view->camera = camera_of(s, o, i);
        view->name = (char*)gsf_alloc(ctx, 32, 1);
        photos[i] = (uint8_t*)gsf_alloc(ctx, pixels, 3);
        if (!(ok = view->name && photos[i])) break;
        snprintf(view->name, 32, "frame_%03d.png", i + 1);
        photo_job job = {s, view->camera, (uint64_t)i, photos[i], depth, normal, exposure_of(o, (uint64_t)i)};
        ctx->parallel.for_fn(ctx->parallel.user, (size_t)o->height, photo_row, &job);
        const gsf_image image = gsf_wrap_image(photos[i], GSF_U8, o->width, o->height, 3);
        snprintf(path, sizeof path, "%s/images/%s", folder, view->name);
        ok = gsf_save_image(ctx, path, &image) == GSF_OK;
        snprintf(path, sizeof path, "%s/truth/depth_%03d.npy", folder, i + 1);
        ok = ok && write_npy(ctx, path, depth, o->width, o->height, 1) == GSF_OK;
        snprintf(path, sizeof path, "%s/truth/normal_%03d.npy", folder, i + 1);
        ok = ok && write_npy(ctx, path, normal, o->width, o->height, 3) == GSF_OK;
        if (isatty(2)) fprintf(stderr, "\rmake_scene: photo %d of %d%s", i + 1, o->views, i + 1 == o->views ? "\n" : "");
    }
    gsf_free(ctx, depth);
    gsf_free(ctx, normal);
    return ok;
}

// Makes the scene and writes all files. Returns 0, or 1 after printing the error.
static int make_scene(gsf_context* ctx, const make_scene_options* options, const char* folder) {
    const make_scene_options* o = options;
    world s;
    cloud c;
    char path[2048];
    memset(&s, 0, sizeof s);
    memset(&c, 0, sizeof c);
    uint8_t** photos = (uint8_t**)gsf_alloc_zeroed(ctx, (size_t)o->views, sizeof *photos);
    c.scene.views = (gsf_scene_view*)gsf_alloc_zeroed(ctx, (size_t)o->views, sizeof(gsf_scene_view));
    int ok = photos && c.scene.views && make_folder(folder, "") && make_folder(folder, "/images") &&
             make_folder(folder, "/truth") && make_folder(folder, "/sparse") && make_folder(folder, "/sparse/0");
    c.scene.view_count = (size_t)o->views;
    ok = ok && start_world(ctx, &s, o);
    ok = ok && take_photos(ctx, &s, o, folder, &c.scene, photos) && find_points(ctx, &s, o, photos, &c);
    snprintf(path, sizeof path, "%s/truth/visibility.bin", folder);
    ok = ok && gsf_splat_save_colmap(ctx, &c.scene, NULL, folder) == GSF_OK && write_truth(ctx, path, &c) == GSF_OK;
    snprintf(path, sizeof path, "%s/truth/scene.json", folder);
    ok = ok && write_options(ctx, path, o) == GSF_OK;
    if (!ok && ctx->error[0]) fprintf(stderr, "make_scene: %s\n", ctx->error);
    if (ok)
        fprintf(
            stderr, "make_scene: %zu triangles, %d photos of %d x %d, %zu points, tracks of %.1f views\n",
            s.triangle_count, o->views, o->width, o->height, c.scene.point_count,
            (double)c.scene.track_begin[c.scene.point_count] / (double)(c.scene.point_count ? c.scene.point_count : 1));
    for (int i = 0; i < o->views; i++) {
        if (photos) gsf_free(ctx, photos[i]);
        if (c.scene.views) gsf_free(ctx, c.scene.views[i].name);
    }
    gsf_free(ctx, photos);
    gsf_free(ctx, c.scene.views);
    gsf_free(ctx, c.scene.points);
    gsf_free(ctx, c.scene.colors);
    gsf_free(ctx, c.scene.point_ids);
    gsf_free(ctx, c.scene.track_begin);
    gsf_free(ctx, c.scene.track_views);
    gsf_free(ctx, c.truth);
    gsf_free(ctx, c.outlier);
    end_world(&s);
    return ok ? 0 : 1;
}

#ifndef MAKE_SCENE_NO_MAIN

// ---- further photos of an existing scene ----------------------------------------

// Reads the options that determine the appearance of the scene. Seeds are below 1e9, which JSON numbers represent exactly.
static gsf_result read_options(gsf_context* ctx, const char* path, make_scene_options* o) {
    static const char* const keys[] = {"width", "height", "seed"};
    double values[3] = {0};
    void* data;
    size_t size;
    gsf_json json;
    gsf_result result = gsf_read_file(ctx, path, &data, &size);
    if (result != GSF_OK) return result;
    result = gsf_parse_json(ctx, path, (const char*)data, size, &json);
    gsf_free(ctx, data);
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < 3 && result == GSF_OK; i++) {
        const gsf_json_value* value = gsf_find_json_member(&json, &json.values[0], keys[i]);
        if (value && value->type == GSF_JSON_NUMBER && value->number >= 0.0 && value->number < 1e9) values[i] = value->number;
        else result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid \"%s\"", path, keys[i]);
    }
    const gsf_json_value* drift = result == GSF_OK ? gsf_find_json_member(&json, &json.values[0], "drift") : NULL;
    const double stops = !drift ? 0.0 : drift->type == GSF_JSON_NUMBER ? drift->number : -1.0;
    gsf_destroy_json(ctx, &json);
    if (result == GSF_OK && !(stops >= 0.0 && stops <= 8.0))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid \"drift\"", path);
    if (result == GSF_OK && !(values[0] >= 16.0 && values[1] >= 16.0 && values[0] <= 8192.0 && values[1] <= 8192.0))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: %g x %g", path, values[0], values[1]);
    *o = make_scene_defaults;
    o->width = (int)values[0];
    o->height = (int)values[1];
    o->seed = (uint64_t)values[2];
    o->drift = stops;
    return result;
}

// Renders the picture, depth map and normals of camera i, with the random numbers of photo i.
static gsf_result render_camera(gsf_context* ctx, const world* s, const gsf_camera* camera, size_t i, float exposure,
                                const char* out) {
    char path[2048];
    const size_t pixels = (size_t)camera->width * (size_t)camera->height;
    gsf_result result = gsf_check_camera(ctx, camera);
    if (result != GSF_OK) return result;
    photo_job job = {s, *camera, (uint64_t)i, (uint8_t*)gsf_alloc(ctx, pixels, 3),
                     (float*)gsf_alloc(ctx, pixels, sizeof(float)), (float*)gsf_alloc(ctx, pixels, 3 * sizeof(float)),
                     exposure};
    result = job.pixels && job.depth && job.normal ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) {
        ctx->parallel.for_fn(ctx->parallel.user, (size_t)camera->height, photo_row, &job);
        const gsf_image image = gsf_wrap_image(job.pixels, GSF_U8, camera->width, camera->height, 3);
        snprintf(path, sizeof path, "%s/%05zu.png", out, i);
        result = gsf_save_image(ctx, path, &image);
    }
    if (result == GSF_OK) {
        snprintf(path, sizeof path, "%s/depth/%05zu.npy", out, i);
        result = write_npy(ctx, path, job.depth, camera->width, camera->height, 1);
    }
    if (result == GSF_OK) {
        snprintf(path, sizeof path, "%s/normal/%05zu.npy", out, i);
        result = write_npy(ctx, path, job.normal, camera->width, camera->height, 3);
    }
    gsf_free(ctx, job.pixels);
    gsf_free(ctx, job.depth);
    gsf_free(ctx, job.normal);
    return result;
}

// Renders the scene in `folder` from the cameras of a file. Returns 0, or 1 after printing the error.
static int render_scene(gsf_context* ctx, const char* folder, const char* cameras, const char* out) {
    char path[2048];
    make_scene_options o = make_scene_defaults;
    gsf_camera* list = NULL;
    size_t count = 0;
    world s;
    memset(&s, 0, sizeof s);
    snprintf(path, sizeof path, "%s/truth/scene.json", folder);
    gsf_result result = read_options(ctx, path, &o);
    if (result == GSF_OK) result = gsf_load_cameras(ctx, cameras, &list, &count);
    int ok = result == GSF_OK && make_folder(out, "") && make_folder(out, "/depth") && make_folder(out, "/normal") &&
             start_world(ctx, &s, &o);
    const float angle = s.pixel_angle;
    for (size_t i = 0; ok && i < count; i++) {
        s.pixel_angle = angle * (float)(0.9 * o.width / list[i].fx); // texture detail for the pixel size of this camera
        result = render_camera(ctx, &s, list + i, i, exposure_of(&o, i), out);
        ok = result == GSF_OK;
    }
    if (result != GSF_OK)
        fprintf(stderr, "make_scene: %s\n", result == GSF_ERROR_OUT_OF_MEMORY ? "out of memory" : ctx->error);
    gsf_free(ctx, list);
    end_world(&s);
    return ok ? 0 : 1;
}

#endif // MAKE_SCENE_NO_MAIN
#endif // GSF_USE_EMBREE

#ifndef MAKE_SCENE_NO_MAIN

static int is_vacant(const char* folder) { // does not exist or is empty
    DIR* list = opendir(folder);
    if (!list) return errno == ENOENT;
    int empty = 1;
    for (struct dirent* entry; (entry = readdir(list)) != NULL;)
        empty &= strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0;
    closedir(list);
    return empty;
}

// Whether make_scene wrote the folder, judging by its visibility.bin.
static int is_made_scene(const char* folder) {
    char path[2048], magic[8] = "";
    snprintf(path, sizeof path, "%s/truth/visibility.bin", folder);
    FILE* truth = fopen(path, "rb");
    const int ours = truth && fread(magic, 1, sizeof magic, truth) == sizeof magic && memcmp(magic, "GSFTRUTH", 8) == 0;
    if (truth) fclose(truth);
    return ours;
}

static int usage(FILE* to) {
    fprintf(
        to,
        "usage: make_scene OUT [--views 40] [--width 320] [--height 240] [--seed 1] [--points 10000] [--noise 0.5] [--arc 150]\n"
        "       [--drift 0]\n"
        "Writes a ray-traced courtyard as photos with a COLMAP model and ground truth into the folder OUT.\n"
        "       make_scene SCENE --render CAMERAS.json --out PICTURES\n"
        "Renders an existing scene from other cameras into the folder PICTURES.\n");
    return to == stdout ? 0 : 2;
}

int main(int argc, char** argv) {
    make_scene_options o = make_scene_defaults;
    const char *folder = NULL, *cameras = NULL, *pictures = NULL;
    for (int i = 1; i < argc; i++) {
        if (strcmp(argv[i], "--help") == 0) return usage(stdout);
        if (argv[i][0] != '-') {
            if (folder) return usage(stderr);
            folder = argv[i];
            continue;
        }
        if (i + 1 >= argc) return usage(stderr);
        if (strcmp(argv[i], "--render") == 0) {
            cameras = argv[++i];
            continue;
        }
        if (strcmp(argv[i], "--out") == 0) {
            pictures = argv[++i];
            continue;
        }
        char* end = NULL;
        const double x = strtod(argv[i + 1], &end);
        if (end == argv[i + 1] || *end || !(x >= 0.0 && x < 1e9)) return usage(stderr);
        if (strcmp(argv[i], "--views") == 0) o.views = (int)x;
        else if (strcmp(argv[i], "--width") == 0) o.width = (int)x;
        else if (strcmp(argv[i], "--height") == 0) o.height = (int)x;
        else if (strcmp(argv[i], "--points") == 0) o.points = (int)x;
        else if (strcmp(argv[i], "--seed") == 0) o.seed = (uint64_t)x;
        else if (strcmp(argv[i], "--noise") == 0) o.noise = x;
        else if (strcmp(argv[i], "--arc") == 0) o.arc = x;
        else if (strcmp(argv[i], "--drift") == 0) o.drift = x;
        else return usage(stderr);
        i++;
    }
    if (!folder || o.views < 2 || o.views > 999 || o.width < 16 || o.height < 16 || o.width > 8192 || o.height > 8192 ||
        o.points < 1 || o.arc > 360.0 || o.drift > 8.0)
        return usage(stderr);
    if (!cameras != !pictures) return usage(stderr);
    if (pictures && !is_vacant(pictures)) {
        fprintf(stderr, "make_scene: %s: already exists (choose a new folder)\n", pictures);
        return 1;
    }
    if (!pictures && !is_vacant(folder) && !is_made_scene(folder)) {
        fprintf(stderr, "make_scene: %s: already exists and was not written by make_scene (choose a new folder)\n", folder);
        return 1;
    }
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK) {
        fprintf(stderr, "make_scene: %s\n", ctx.error);
        return 1;
    }
    return cameras ? render_scene(&ctx, folder, cameras, pictures) : make_scene(&ctx, &o, folder);
}

#endif // MAKE_SCENE_NO_MAIN
