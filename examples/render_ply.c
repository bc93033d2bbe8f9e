// render_ply.c - cc -O2 -std=c11 -fopenmp -DGSFIXER_IMPLEMENTATION -I. examples/render_ply.c -o render_ply -lm
// Renders splats (.ply, .splat, .spz, .glb) to PNG files:   render_ply SPLATS OUT_PREFIX [CAMERAS.json]
// Without a camera list (the format of `gsfix path`) it renders an orbit of 8 images around the centre of the splats.
// Writes OUT_PREFIX000.png, OUT_PREFIX001.png, ...
#include "gsfixer_splat.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { ORBIT_COUNT = 8, ORBIT_WIDTH = 640, ORBIT_HEIGHT = 480 };

static int compare_floats(const void* a, const void* b) {
    const float x = *(const float*)a, y = *(const float*)b;
    return (x > y) - (x < y);
}

// Median position and median distance from it, which are robust against stray splats.
static gsf_result measure_splats(gsf_context* ctx, const gsf_splats* splats, double center[3], double* radius) {
    const size_t n = splats->count;
    if (n == 0) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "there are no splats to look at");
    float* sorted = (float*)gsf_alloc(ctx, n, sizeof *sorted);
    if (!sorted) return GSF_ERROR_OUT_OF_MEMORY;
    float middle[3];
    for (int a = 0; a < 3; a++) {
        for (size_t i = 0; i < n; i++) sorted[i] = splats->means[3 * i + (size_t)a];
        qsort(sorted, n, sizeof *sorted, compare_floats);
        middle[a] = sorted[n / 2];
        center[a] = splats->origin[a] + (double)middle[a];
    }
    for (size_t i = 0; i < n; i++) {
        const float* m = splats->means + 3 * i;
        const float dx = m[0] - middle[0], dy = m[1] - middle[1], dz = m[2] - middle[2];
        sorted[i] = sqrtf(dx * dx + dy * dy + dz * dz);
    }
    qsort(sorted, n, sizeof *sorted, compare_floats);
    *radius = (double)sorted[n / 2] > 0.0 ? (double)sorted[n / 2] : 1.0;
    gsf_free(ctx, sorted);
    return GSF_OK;
}

// Turns around the vertical (y) axis, looking at the centre from 4 radii away and slightly from above (y points down).
static gsf_camera orbit_camera(const double center[3], double radius, int index) {
    const double turn = 6.283185307179586 * index / ORBIT_COUNT, tilt = 0.35;
    const double forward[3] = {cos(tilt) * sin(turn), sin(tilt), cos(tilt) * cos(turn)};
    const double right[3] = {cos(turn), 0.0, -sin(turn)};
    const double down[3] = {forward[1] * right[2] - forward[2] * right[1],
                            forward[2] * right[0] - forward[0] * right[2],
                            forward[0] * right[1] - forward[1] * right[0]};
    double c2w[16] = {0};
    for (int a = 0; a < 3; a++) {
        c2w[a] = right[a];
        c2w[4 + a] = down[a];
        c2w[8 + a] = forward[a];
        c2w[12 + a] = center[a] - 4.0 * radius * forward[a];
    }
    c2w[15] = 1.0;
    gsf_camera camera = {0};
    camera.fx = camera.fy = ORBIT_HEIGHT;
    camera.cx = ORBIT_WIDTH / 2.0;
    camera.cy = ORBIT_HEIGHT / 2.0;
    camera.width = ORBIT_WIDTH;
    camera.height = ORBIT_HEIGHT;
    gsf_set_camera_c2w(&camera, c2w);
    return camera;
}

static gsf_result make_orbit(gsf_context* ctx, const gsf_splats* splats, gsf_camera** cameras, size_t* count) {
    double center[3] = {0}, radius = 1.0;
    const gsf_result result = measure_splats(ctx, splats, center, &radius);
    if (result != GSF_OK) return result;
    *cameras = (gsf_camera*)gsf_alloc(ctx, ORBIT_COUNT, sizeof **cameras);
    if (!*cameras) return GSF_ERROR_OUT_OF_MEMORY;
    for (int i = 0; i < ORBIT_COUNT; i++) (*cameras)[i] = orbit_camera(center, radius, i);
    *count = ORBIT_COUNT;
    return GSF_OK;
}

static gsf_result render_one(gsf_context* ctx, gsf_rasterizer* rasterizer, const gsf_splats* splats,
                             const gsf_camera* camera, const char* path) {
    gsf_render_output out = {0};
    gsf_render_desc desc = {0};
    desc.antialiased = splats->antialiased;
    memcpy(desc.background, splats->background, sizeof desc.background);
    gsf_result result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &out.color);
    if (result == GSF_OK) result = gsf_splat_render(ctx, rasterizer, splats, camera, &desc, &out);
    if (result == GSF_OK) result = gsf_save_image(ctx, path, &out.color);
    gsf_destroy_image(ctx, &out.color);
    return result;
}

int main(int argc, char** argv) {
    if (argc < 3 || argc > 4)
        return fprintf(stderr, "usage: %s SPLATS OUT_PREFIX [CAMERAS.json]\n", argv[0]), 2;
    gsf_context ctx = {0};
    gsf_splats splats = {0};
    gsf_rasterizer* rasterizer = NULL;
    gsf_camera* cameras = NULL;
    size_t count = 0;
    gsf_result result = gsf_init_context(&ctx);
    if (result == GSF_OK) result = gsf_splat_load(&ctx, argv[1], &splats);
    if (result == GSF_OK)
        result = argc > 3 ? gsf_load_cameras(&ctx, argv[3], &cameras, &count)
                          : make_orbit(&ctx, &splats, &cameras, &count);
    if (result == GSF_OK) result = gsf_splat_make_rasterizer(&ctx, &rasterizer);
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        gsf_buffer path = {0};
        gsf_append_text(&ctx, &path, "%s%03zu.png", argv[2], i);
        result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : render_one(&ctx, rasterizer, &splats, &cameras[i], path.data);
        if (result == GSF_OK) printf("%s\n", path.data);
        gsf_destroy_buffer(&ctx, &path);
    }
    if (result != GSF_OK) fprintf(stderr, "%s\n", ctx.error);
    gsf_splat_destroy_rasterizer(&ctx, rasterizer);
    gsf_free(&ctx, cameras);
    gsf_splat_destroy(&ctx, &splats);
    return result == GSF_OK ? 0 : 1;
}
