// scene_points.h - the points that feature matching would find. Part of make_scene.c.
// SPDX-License-Identifier: MIT
#ifndef SCENE_POINTS_H
#define SCENE_POINTS_H

#include "scene_photos.h"

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

#endif // SCENE_POINTS_H
