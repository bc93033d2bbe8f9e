/* make_scene - a small courtyard, ray traced, written as if photographed and reconstructed by COLMAP
   gcc -O2 -std=c11 -fopenmp -DGSFIXER_IMPLEMENTATION -I. examples/make_scene.c -o make_scene -lm
   (with Embree, which traces the rays faster: -DGSF_USE_EMBREE and -lembree3 or -lembree4)

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

#include "scene_layouts.h"
#include "scene_points.h"

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
    const mesh_view mesh = {s->vertices, sizeof(vertex), s->vertex_count, (const uint32_t*)s->triangles, s->triangle_count};
    const char* error = s->failed ? "out of memory" : start_tracer(&s->rays, &mesh);
    if (error) {
        fprintf(stderr, "make_scene: %s\n", error);
        return 0;
    }
    bake_job bake = {s, bake_rays};
    ctx->parallel.for_fn(ctx->parallel.user, (s->vertex_count + BAKE_CHUNK - 1) / BAKE_CHUNK, bake_chunk, &bake);
    return 1;
}

static void end_world(world* s) {
    end_tracer(&s->rays);
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
