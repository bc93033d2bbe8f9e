// gsfix_orbit.h - a camera that goes around a point, of gsfix view and of the web page.
// SPDX-License-Identifier: MIT
#ifndef GSFIX_ORBIT_H
#define GSFIX_ORBIT_H

#include "gsfixer_splat.h"

#include <math.h>
#include <stdlib.h>

typedef struct gsfix_orbit {
    gsf_camera camera;
    double c2w[16], pivot[3], up[3];
} gsfix_orbit;

static double* orbit_axis(gsfix_orbit* o, int axis) { return o->c2w + 4 * axis; } // right, down, forward; 3: position

static void orbit_rotate(const double axis[3], double angle, double x[3]) { // Rodrigues
    const double c = cos(angle), s = sin(angle), along = (axis[0] * x[0] + axis[1] * x[1] + axis[2] * x[2]) * (1.0 - c);
    const double cross[3] = {axis[1] * x[2] - axis[2] * x[1], axis[2] * x[0] - axis[0] * x[2], axis[0] * x[1] - axis[1] * x[0]};
    for (int k = 0; k < 3; k++) x[k] = x[k] * c + cross[k] * s + axis[k] * along;
}

static void orbit_turn(gsfix_orbit* o, const double axis[3], double angle) { // about the pivot
    double arm[3];
    for (int k = 0; k < 3; k++) arm[k] = orbit_axis(o, 3)[k] - o->pivot[k];
    orbit_rotate(axis, angle, arm);
    for (int k = 0; k < 3; k++) orbit_axis(o, 3)[k] = o->pivot[k] + arm[k];
    for (int a = 0; a < 3; a++) orbit_rotate(axis, angle, orbit_axis(o, a));
    gsf_set_camera_c2w(&o->camera, o->c2w);
}

// By a mouse that moved so many pixels.
static void orbit_drag(gsfix_orbit* o, double x, double y) {
    orbit_turn(o, o->up, -0.006 * x);
    const double right[3] = {o->c2w[0], o->c2w[1], o->c2w[2]};
    orbit_turn(o, right, -0.006 * y);
}

static void orbit_shift(gsfix_orbit* o, int axis, double distance, int with_pivot) {
    for (int k = 0; k < 3; k++) {
        const double step = orbit_axis(o, axis)[k] * distance;
        orbit_axis(o, 3)[k] += step;
        if (with_pivot) o->pivot[k] += step;
    }
    gsf_set_camera_c2w(&o->camera, o->c2w);
}

static double orbit_distance(const gsfix_orbit* o) { // to the pivot
    double sum = 0.0;
    for (int k = 0; k < 3; k++) sum += (o->c2w[12 + k] - o->pivot[k]) * (o->c2w[12 + k] - o->pivot[k]);
    return sqrt(sum) + 1e-9;
}

// Looks from a photo's camera, with its field of view in a window of any shape.
static void orbit_from(gsfix_orbit* o, const gsf_camera* from, int32_t width, int32_t height) {
    const gsf_camera source = *from; // may be the orbit's own
    const double scale = fmin((double)width / source.width, (double)height / source.height);
    o->camera = source;
    o->camera.width = width;
    o->camera.height = height;
    o->camera.fx = source.fx * scale;
    o->camera.fy = source.fy * scale;
    o->camera.cx = width / 2.0 + (source.cx - source.width / 2.0) * scale;
    o->camera.cy = height / 2.0 + (source.cy - source.height / 2.0) * scale;
    gsf_get_camera_c2w(&source, o->c2w);
}

// The photos' mean up; against y if there is none.
static void orbit_set_up(gsfix_orbit* o, const gsf_train_view* views, size_t count) {
    for (int k = 0; k < 3; k++) o->up[k] = 0.0;
    for (size_t i = 0; i < count; i++) {
        double c2w[16];
        gsf_get_camera_c2w(&views[i].camera, c2w);
        for (int k = 0; k < 3; k++) o->up[k] -= c2w[4 + k];
    }
    const double length = sqrt(o->up[0] * o->up[0] + o->up[1] * o->up[1] + o->up[2] * o->up[2]);
    for (int k = 0; k < 3; k++) o->up[k] = length > 1e-6 ? o->up[k] / length : k == 1 ? -1.0 : 0.0;
}

static int orbit_compare(const void* a, const void* b) {
    const float x = *(const float*)a, y = *(const float*)b;
    return (x > y) - (x < y);
}

// Turns around the median position of splats; three quarters of them are within `radius` of it along each axis.
static gsf_result orbit_set_pivot(gsf_context* ctx, gsfix_orbit* o, const gsf_splats* s, double* radius) {
    float* values = (float*)gsf_alloc(ctx, s->count + 1, sizeof *values);
    if (!values) return GSF_ERROR_OUT_OF_MEMORY;
    *radius = 1e-3;
    for (int k = 0; k < 3 && s->count; k++) {
        for (size_t i = 0; i < s->count; i++) values[i] = s->means[3 * i + (size_t)k];
        qsort(values, s->count, sizeof *values, orbit_compare);
        o->pivot[k] = s->origin[k] + (double)values[s->count / 2];
        *radius = fmax(*radius, (double)(values[s->count * 7 / 8] - values[s->count / 8]) / 2.0);
    }
    gsf_free(ctx, values);
    return GSF_OK;
}

// In front of splats, which have no photos: y is down.
static gsf_result orbit_face(gsf_context* ctx, gsfix_orbit* o, const gsf_splats* s, int32_t width, int32_t height,
                             double* radius) {
    const gsf_result result = orbit_set_pivot(ctx, o, s, radius);
    if (result != GSF_OK) return result;
    const gsf_camera camera = {{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -o->pivot[0], -o->pivot[1], 3.0 * *radius - o->pivot[2], 1},
                               1.1 * height, 1.1 * height, width / 2.0, height / 2.0, width, height};
    orbit_from(o, &camera, width, height);
    orbit_set_up(o, NULL, 0);
    return GSF_OK;
}

#endif // GSFIX_ORBIT_H
