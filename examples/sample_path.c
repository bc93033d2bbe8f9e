// sample_path.c - cc -O2 -std=c11 -I. examples/sample_path.c -o sample_path -lm && ./sample_path
// Samples a camera path through a few views and writes it as JSON (gsf_save_cameras).
//     sample_path [--cameras CAMERAS.json] [--kind reference|ellipse|interpolate|spread] [--windows N] [--length N]
//                 [--round N] [--seed N] [--official] [--out PATH.json] [x,y,z ...]
// Cameras come from a file, or stand at the given positions and look at the origin (z is up); by default three do.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_traj.h"

enum { CAMERAS_MAX = 64 };

typedef struct options {
    const char *cameras, *out;
    gsf_traj_path_desc desc;
    double positions[CAMERAS_MAX][3];
    size_t position_count;
} options;

static int parse_options(int argc, char** argv, options* o) { // 0 = bad usage
    memset(o, 0, sizeof *o);
    o->out = "path.json";
    for (int i = 1; i < argc; i++) {
        const char *name = argv[i], *value = i + 1 < argc ? argv[i + 1] : "";
        if (strncmp(name, "--", 2) != 0) {
            double* p = o->positions[o->position_count];
            if (o->position_count == CAMERAS_MAX || sscanf(name, "%lf,%lf,%lf", p, p + 1, p + 2) != 3) return 0;
            o->position_count++;
            continue;
        }
        if (strcmp(name, "--official") == 0) { o->desc.official = 1; continue; }
        if (strcmp(name, "--cameras") == 0) o->cameras = value;
        else if (strcmp(name, "--out") == 0) o->out = value;
        else if (strcmp(name, "--windows") == 0) o->desc.window_count = atoi(value);
        else if (strcmp(name, "--length") == 0) o->desc.window_length = atoi(value);
        else if (strcmp(name, "--round") == 0) o->desc.round = atoi(value);
        else if (strcmp(name, "--seed") == 0) o->desc.seed = strtoull(value, NULL, 10);
        else if (strcmp(name, "--kind") != 0) return 0;
        else if (strcmp(value, "reference") == 0) o->desc.kind = GSF_TRAJ_REFERENCE;
        else if (strcmp(value, "ellipse") == 0) o->desc.kind = GSF_TRAJ_ELLIPSE;
        else if (strcmp(value, "interpolate") == 0) o->desc.kind = GSF_TRAJ_INTERPOLATE;
        else if (strcmp(value, "spread") == 0) o->desc.kind = GSF_TRAJ_SPREAD;
        else return 0;
        if (++i == argc) return 0;
    }
    return 1;
}

// One camera per position, all looking at the origin.
static gsf_result make_cameras(gsf_context* ctx, const options* o, gsf_camera** cameras, size_t* count) {
    static const double three[3][3] = {{2.0, 0.0, 0.8}, {1.0, 1.8, 0.7}, {-1.2, 1.5, 0.9}};
    const double origin[3] = {0.0, 0.0, 0.0}, up[3] = {0.0, 0.0, 1.0};
    const double(*positions)[3] = o->position_count ? o->positions : three;
    *count = o->position_count ? o->position_count : 3;
    *cameras = (gsf_camera*)gsf_alloc_zeroed(ctx, *count, sizeof **cameras);
    if (!*cameras) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < *count; i++) {
        gsf_camera* camera = *cameras + i;
        double pose[16];
        const gsf_result result = gsf_traj_look_at(ctx, positions[i], origin, up, pose);
        if (result != GSF_OK) return result;
        camera->width = 720;
        camera->height = 480;
        camera->fx = camera->fy = 0.5 * camera->width / tan(0.5); // sees one radian across
        camera->cx = 360.0;
        camera->cy = 240.0;
        gsf_set_camera_c2w(camera, pose);
    }
    return GSF_OK;
}

static double length_of(const gsf_camera* frames, size_t count) {
    double sum = 0.0, a[3], b[3];
    for (size_t f = 1; f < count; f++) {
        gsf_get_camera_center(&frames[f - 1], a);
        gsf_get_camera_center(&frames[f], b);
        sum += sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) + (a[2] - b[2]) * (a[2] - b[2]));
    }
    return sum;
}

static gsf_result run(gsf_context* ctx, const options* o, const gsf_camera* cameras, size_t count) {
    gsf_traj_path_info layout;
    gsf_result result = gsf_traj_query_path(ctx, count, &o->desc, &layout);
    if (result != GSF_OK) return result;
    gsf_camera* frames = (gsf_camera*)gsf_alloc(ctx, layout.frame_count, sizeof *frames);
    int32_t* reference = (int32_t*)gsf_alloc(ctx, layout.frame_count, sizeof *reference);
    void* scratch = gsf_alloc(ctx, layout.scratch_bytes, 1);
    result = GSF_ERROR_OUT_OF_MEMORY;
    if (frames && reference && scratch)
        result = gsf_traj_sample_path(ctx, cameras, count, &o->desc, scratch, frames, reference);
    if (result == GSF_OK) result = gsf_save_cameras(ctx, o->out, frames, NULL, layout.frame_count);
    if (result == GSF_OK) {
        const size_t n = (size_t)layout.window_length;
        printf("%zu cameras -> %d windows of %zu frames in %s\n", count, (int)layout.window_count, n, o->out);
        for (size_t w = 0; w < (size_t)layout.window_count; w++) {
            const int32_t first = reference[w * n], last = reference[w * n + n - 1];
            printf("window %zu: length %.3f", w, length_of(frames + w * n, n));
            if (first >= 0) printf(", starts at view %d", (int)first);
            if (last >= 0) printf(", ends at view %d", (int)last);
            printf("\n");
        }
    }
    gsf_free(ctx, scratch);
    gsf_free(ctx, reference);
    gsf_free(ctx, frames);
    return result;
}

int main(int argc, char** argv) {
    options o;
    if (!parse_options(argc, argv, &o)) {
        fprintf(stderr, "usage: %s [--cameras FILE] [--kind reference|ellipse|interpolate|spread] [--windows N] [--length N]\n"
                        "       [--round N] [--seed N] [--official] [--out FILE] [x,y,z ...]\n", argv[0]);
        return 2;
    }
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    gsf_camera* cameras = NULL;
    size_t count = 0;
    gsf_result result = gsf_init_context(&ctx);
    if (result == GSF_OK)
        result = o.cameras ? gsf_load_cameras(&ctx, o.cameras, &cameras, &count)
                           : make_cameras(&ctx, &o, &cameras, &count);
    if (result == GSF_OK) result = run(&ctx, &o, cameras, count);
    gsf_free(&ctx, cameras);
    if (result != GSF_OK) fprintf(stderr, "%s: %s\n", gsf_describe_result(result), ctx.error);
    return result == GSF_OK ? 0 : 1;
}
