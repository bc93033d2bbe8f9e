// scene_photos.h - cameras and the photos they take, with depth and normals. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_PHOTOS_H
#define SCENE_PHOTOS_H

#include "scene_light.h"

typedef struct photo_job {
    const world* s;
    gsf_camera camera;
    uint64_t view;
    uint8_t* pixels; // (height,width,3)
    float* depth;    // (height,width)
    float* normal;   // (height,width,3)
    float exposure; // factor
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
static v3 ray_through(const gsf_camera* camera, double x, double y,
                      float* z) { // z: camera depth per unit of ray length
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
    const float exposure = job->exposure * job->s->exposure;
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
            v3 c = sky(job->s, d);
            if (trace(job->s, eye, d, 0.01f, &h)) {
                const float r1 =
                    ((float)k + random3(at, 1, (int32_t)job->view)) / SAMPLES; // one sample per ring of the sun's disc
                c = shade(job->s, &h, d, r1, random3((int32_t)pixel, 2, (int32_t)job->view) + 0.381966f * (float)k, 0);
                c = mix(c, job->s->air.haze, minf(job->s->air.haze_density * h.t, 1.0f));
            }
            sum = add(sum, v(minf(c.x, 4), minf(c.y, 4), minf(c.z, 4)));
        }
        const float px = 2.0f * ((float)x + 0.5f) / (float)width - 1.0f,
                    py = 2.0f * ((float)row + 0.5f) / (float)height - 1.0f;
        sum = mul(sum, (1.0f - 0.11f * (px * px + py * py)) / SAMPLES); // vignetting
        const float c[3] = {film(exposure * sum.x), film(exposure * sum.y), film(exposure * sum.z)};
        for (size_t k = 0; k < 3; k++) { // sensor noise
            const float grain = 1.1f * (float)gsf_draw_normal(job->s->seed, 100 + job->view, 3 * pixel + k);
            job->pixels[3 * pixel + k] = (uint8_t)clampf(255.0f * c[k] + grain + 0.5f, 0, 255);
        }
    }
}

typedef struct camera_pose { v3 eye, forward; float roll; } camera_pose;

// A handheld camera carried around the courtyard's table: distance, height, aim and roll vary.
static camera_pose pose_in_courtyard(world* s, const make_scene_options* o, int view) {
    const float t = ((float)view + 0.5f) / (float)o->views - 0.5f,
                step = (float)(o->arc * 3.14159265 / 180.0) / (float)o->views;
    const uint64_t k = 16 * (uint64_t)view;
    const float angle = -1.40f + (float)(o->arc * 3.14159265 / 180.0) * t + pick(s, 1, k, -0.3f, 0.3f) * step;
    const float distance = 2.25f + 0.18f * sinf(9.0f * t) + pick(s, 1, k + 1, -0.12f, 0.12f);
    const float height = 1.50f + 0.22f * sinf(14.0f * t + 1.0f) + pick(s, 1, k + 2, -0.09f, 0.09f);
    const v3 eye = v(distance * cosf(angle), distance * sinf(angle), height);
    const v3 aim =
        v(pick(s, 1, k + 3, -0.08f, 0.08f), pick(s, 1, k + 4, -0.08f, 0.08f), pick(s, 1, k + 5, 0.58f, 0.70f));
    const camera_pose p = {eye, unit(sub(aim, eye)), pick(s, 1, k + 6, -0.03f, 0.03f)};
    return p;
}

// Moves a point out of the neighbourhood of surfaces, so that no camera is inside of one or has it before the lens.
static v3 keep_clear(const world* s, v3 at) {
    enum { DIRECTIONS = 40 };
    const float margin = 0.35f;
    for (int round = 0; round < 12; round++) {
        v3 push = v(0, 0, 0);
        for (int i = 0; i < DIRECTIONS; i++) {
            const float z = 1.0f - (2.0f * (float)i + 1.0f) / DIRECTIONS, r = sqrtf(1.0f - z * z),
                        a = 2.3999632f * (float)i;
            const v3 d = v(r * cosf(a), r * sinf(a), z);
            hit h;
            if (trace(s, at, d, 0.0f, &h) && h.t < margin) push = sub(push, mul(d, margin - h.t));
        }
        if (dot(push, push) < 1e-6f) return at;
        at = add(at, mul(push, 0.25f));
    }
    return at;
}

static camera_pose pose_of(world* s, const make_scene_options* o, int view) {
    const capture* c = &s->capture;
    const float t = ((float)view + 0.5f) / (float)o->views; // of the way
    const uint64_t k = 16 * (uint64_t)view;
    const v3 shake = v(pick(s, 1, k, -1, 1), pick(s, 1, k + 1, -1, 1), pick(s, 1, k + 2, -1, 1));
    camera_pose p = {c->from, v(1, 0, 0), pick(s, 1, k + 3, -0.025f, 0.025f)};
    v3 aim = c->aim;
    if (c->kind == ORBIT) {
        const float angle = c->start + (float)(o->arc * 3.14159265 / 180.0) * (t - 0.5f);
        const float distance = c->distance * (1.0f + 0.07f * sinf(11.0f * t));
        p.eye = v(aim.x + distance * cosf(angle), aim.y + distance * sinf(angle),
                  c->height * (1.0f + 0.14f * sinf(17.0f * t)));
        p.eye = add(p.eye, mul(shake, 0.03f * c->distance));
        aim = add(aim, mul(shake, 0.02f * c->distance));
    } else if (c->kind == FORWARD) { // rows of positions, passed to and fro
        enum { ROWS = 5 };
        const int row = (int)(t * ROWS);
        const float along = t * ROWS - (float)row, across = row & 1 ? 1.0f - along : along;
        const v3 right = unit(cross(sub(c->aim, c->from), v(0, 0, 1)));
        v3 offset = add(mul(right, c->spread * (2.0f * across - 1.0f)),
                        v(0, 0, 0.55f * c->spread * ((float)row / 2.0f - 1.0f)));
        offset = add(offset, mul(shake, 0.06f * c->spread));
        p.eye = add(c->from, offset);
        aim = add(aim, mul(offset, 0.4f));
    } else {
        const v3 way = sub(c->aim, c->from), side = unit(cross(way, v(0, 0, 1)));
        p.eye = add(add(c->from, mul(way, t)), mul(side, c->spread * sinf(9.0f * t)));
        p.eye = add(p.eye, mul(shake, 0.05f));
        const v3 ahead = rotate_z(unit(way), c->start + c->turn * sinf(15.0f * t));
        aim = add(p.eye, v(ahead.x, ahead.y, -0.08f + 0.07f * sinf(21.0f * t)));
    }
    const v3 clear = keep_clear(s, p.eye);
    p.forward = unit(sub(aim, c->kind == WALK ? p.eye : clear));
    p.eye = clear;
    return p;
}

// Focal length / width, with two decimals exact.
static double focal_of(const world* s) { return floor(100.0 * (double)s->capture.focal + 0.5) / 100.0; }

static gsf_camera camera_of(world* s, const make_scene_options* o, int view) {
    gsf_camera c;
    memset(&c, 0, sizeof c);
    const camera_pose p = s->layout == 0 ? pose_in_courtyard(s, o, view) : pose_of(s, o, view);
    const v3 eye = p.eye, forward = p.forward, level = unit(cross(forward, v(0, 0, 1)));
    const float roll = p.roll;
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
    c.fx = c.fy = focal_of(s) * o->width;
    c.cx = 0.5 * o->width;
    c.cy = 0.5 * o->height;
    return c;
}

// Exposes for the logarithmic mean of what a few of the cameras see.
static float meter(world* s, const make_scene_options* options) {
    enum { SHOTS = 5, COLUMNS = 16, ROWS = 12 };
    double sum = 0.0;
    make_scene_options usual = *options; // for later photos of the scene, whatever their number
    usual.views = make_scene_defaults.views, usual.arc = make_scene_defaults.arc;
    const make_scene_options* o = &usual;
    for (int shot = 0; shot < SHOTS; shot++) {
        const gsf_camera camera = camera_of(s, o, (2 * shot + 1) * o->views / (2 * SHOTS));
        const v3 eye = eye_of(&camera);
        for (int i = 0; i < COLUMNS * ROWS; i++) {
            float z;
            hit h;
            const v3 d = ray_through(&camera, ((i % COLUMNS) + 0.5) * o->width / COLUMNS,
                                     ((i / COLUMNS) + 0.5) * o->height / ROWS, &z);
            const v3 c = trace(s, eye, d, 0.01f, &h) ? shade(s, &h, d, 0.5f, 0.5f, 0) : sky(s, d);
            sum += log(0.02 + (double)(0.3f * c.x + 0.6f * c.y + 0.1f * c.z));
        }
    }
    return clampf(0.46f / (float)exp(sum / (SHOTS * COLUMNS * ROWS)), 0.3f, 8.0f);
}

#endif // SCENE_PHOTOS_H
