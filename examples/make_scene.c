/* make_scene - procedural scenes, ray traced, written as if photographed and reconstructed by COLMAP
   gcc -O2 -std=c11 -fopenmp -DGSFIXER_IMPLEMENTATION -I. examples/make_scene.c -o make_scene -lm
   (with Embree, which traces the rays faster: -DGSF_USE_EMBREE and -lembree3 or -lembree4)

       make_scene OUT [--layout courtyard] [--seed 1] [--views 40] [--width 320] [--height 240] [--points 10000]
           [--noise 0.5] [--arc 150] [--drift 0]
       make_scene OUT --scene NAME [...]

   --layout: the kind of scene (see --help), `any`: that of the seed. The seed chooses rooms, things, materials, light
   and the way of the camera: a fixed layout has as many scenes as there are seeds. --scene: a scene of the benchmark,
   whose names --suite lists; its layout, seed, arc and drift, unless options after it say otherwise.
   --noise: standard deviation of feature positions in pixels; --arc: angle in degrees of an orbiting camera's path;
   --drift: the exposure rises and falls by so many stops from photo to photo. `--views 12 --width 96 --height 64` takes
   less than two seconds. OUT/images/frame_001.png ... OUT/sparse/0/{cameras,images,points3D}.bin   points as feature
   matching would find them: in textured areas, triangulated from noisy pixels, matched in only some of the views that
   can see them, a few of them outliers OUT/splits/{test,train_3,train_6,train_9}.txt  names of photos: every 8th, and
   the training photos among the others OUT/truth/depth_001.npy ...                  float32 (height,width) camera depth
   at pixel centres, 0 = sky OUT/truth/normal_001.npy ...                 float32 (height,width,3) unit normals of the
   triangles there, as flat as the depth is, in the axes of the COLMAP model, towards the camera; 0 = sky. A mirror's
   depth and normal are those of its surface OUT/truth/visibility.bin                     see write_truth
       OUT/truth/scene.json                         the options it was made with
   OUT must be a new folder, an empty one or one written by make_scene, so that no other files are replaced.

       make_scene SCENE --render CAMERAS.json --out PICTURES

   renders an existing scene from other cameras (the format of `gsfix path`) like additional photos of it, with the same
   light and sensor noise. With the scene's own cameras, it reproduces the scene's photos.
       PICTURES/00000.png ...        in the order of the cameras
       PICTURES/depth/00000.npy, PICTURES/normal/00000.npy ...  as in OUT/truth
   PICTURES must be a new or an empty folder.

       make_scene --sheet N --out SHEET.png

   draws one photo of each of the scenes `--layout any --seed 1` to N, and prints which two are the most alike. */
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
#ifdef _WIN32
#include <direct.h>
#define mkdir(path, mode) _mkdir(path)
#endif

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
static gsf_result write_npy(gsf_context* ctx, const char* path, const float* values, int width, int height,
                            int channels) {
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
    char text[400], drift[48] = "", layout[48] = "";
    if (o->layout != 0) snprintf(layout, sizeof layout, ",\"layout\":\"%s\"", layouts[o->layout].name);
    if (o->drift != 0.0) snprintf(drift, sizeof drift, ",\"drift\":%.17g", o->drift);
    const int size = snprintf(text, sizeof text,
                              "{\"views\":%d,\"width\":%d,\"height\":%d,\"points\":%d,\"noise\":%.17g,"
                              "\"arc\":%.17g,\"seed\":%llu%s%s}\n",
                              o->views, o->width, o->height, o->points, o->noise, o->arc, (unsigned long long)o->seed,
                              drift, layout);
    return gsf_write_file(ctx, path, text, (size_t)size);
}

// OUT/splits: the papers' protocol, the one of `gsfix fix --views 3`. Numbers of training photos that there are not are
// left out.
static int write_splits(gsf_context* ctx, const char* folder, const gsf_scene* scene) {
    const size_t views = scene->view_count, room = views + 9;
    uint32_t *chosen = (uint32_t*)gsf_alloc(ctx, room, 2 * sizeof(uint32_t)), *held_out = chosen ? chosen + room : NULL;
    int ok = chosen && make_folder(folder, "/splits");
    for (size_t k = 0; ok && k <= 9; k += 3) { // 0: the test photos
        char path[2048];
        size_t train, test;
        gsf_buffer out;
        gsf_splat_split_views(views, 8, k, chosen, &train, held_out, &test);
        if (k > views - test) continue;
        memset(&out, 0, sizeof out);
        for (size_t i = 0; i < (k ? train : test); i++)
            gsf_append_text(ctx, &out, "%s\n", scene->views[k ? chosen[i] : held_out[i]].name);
        if (k) snprintf(path, sizeof path, "%s/splits/train_%zu.txt", folder, k);
        else snprintf(path, sizeof path, "%s/splits/test.txt", folder);
        ok = !out.failed && gsf_write_file(ctx, path, out.data, out.size) == GSF_OK;
        gsf_destroy_buffer(ctx, &out);
    }
    gsf_free(ctx, chosen);
    return ok;
}

// ---- scene ---------------------------------------------------------------------

static int start_world(gsf_context* ctx, world* s, const make_scene_options* o) {
    const int bake_rays = o->width * o->height < 20000 ? 8
                          : o->layout == 0             ? 32
                                                       : 20;  // few are enough for small photos
    s->seed = o->seed;
    make_lattice();
    s->layout = o->layout;
    layouts[o->layout].build(s);
    s->pixel_angle = 1.0f / (s->capture.focal * (float)o->width);
    const mesh_view mesh = {s->vertices, sizeof(vertex), s->vertex_count, (const uint32_t*)s->triangles,
                            s->triangle_count};
    const char* error = s->failed ? "out of memory" : start_tracer(&s->rays, &mesh);
    if (error) {
        fprintf(stderr, "make_scene: %s\n", error);
        return 0;
    }
    if (!bake_light(ctx, s, bake_rays)) {
        fprintf(stderr, "make_scene: out of memory\n");
        return 0;
    }
    s->exposure = o->layout == 0 ? 1.0f : meter(s, o);
    return 1;
}

static void end_world(world* s) {
    end_tracer(&s->rays);
    free(s->vertices);
    free(s->triangles);
    free(s->surfaces);
    free(s->patches);
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
        if (isatty(2))
            fprintf(stderr, "\rmake_scene: photo %d of %d%s", i + 1, o->views, i + 1 == o->views ? "\n" : "");
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
    ok = ok && write_options(ctx, path, o) == GSF_OK && write_splits(ctx, folder, &c.scene);
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

// ---- benchmark -------------------------------------------------------------------

typedef struct named_scene { const char *name, *layout; int seed; double arc, drift; } named_scene;

static const named_scene suite[] = {
    {"breakfast", "still_life", 1, 150, 0},   {"terrace", "still_life", 12, 180, 1.0},
    {"picnic", "still_life", 23, 360, 0},     {"parlour", "living_room", 2, 100, 0.5},
    {"study", "living_room", 13, 90, 0},      {"hotel", "corridor", 3, 0, 0.6},
    {"school", "corridor", 14, 0, 0},         {"library", "bookshelf", 4, 0, 0},
    {"curiosities", "bookshelf", 15, 0, 0.4}, {"old_town", "street", 5, 0, 0},
    {"high_street", "street", 16, 0, 1.0},    {"townhouse", "facade", 6, 0, 0},
    {"bookshop", "facade", 28, 0, 0.8},       {"orchard", "garden", 7, 120, 1.2},
    {"rose_garden", "garden", 18, 120, 0},    {"square", "monument", 8, 360, 0.8},
    {"obelisk", "monument", 19, 200, 0},      {"farmhouse", "kitchen", 9, 0, 0},
    {"museum", "gallery", 10, 0, 0},          {"greengrocer", "market", 11, 110, 0.5},
};
enum { SUITE = sizeof suite / sizeof *suite };

static int find_layout(const char* name) { // -1: there is none
    for (int i = 0; i < LAYOUTS; i++)
        if (strcmp(layouts[i].name, name) == 0) return i;
    return -1;
}

// ---- further photos of an existing scene ----------------------------------------

// Reads the options that determine the appearance of the scene. Seeds are below 1e9, which JSON numbers represent
// exactly.
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
        if (value && value->type == GSF_JSON_NUMBER && value->number >= 0.0 && value->number < 1e9)
            values[i] = value->number;
        else result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid \"%s\"", path, keys[i]);
    }
    const gsf_json_value* drift = result == GSF_OK ? gsf_find_json_member(&json, &json.values[0], "drift") : NULL;
    const double stops = !drift ? 0.0 : drift->type == GSF_JSON_NUMBER ? drift->number : -1.0;
    const gsf_json_value* layout = result == GSF_OK ? gsf_find_json_member(&json, &json.values[0], "layout") : NULL;
    const int kind = !layout ? 0 : layout->type == GSF_JSON_STRING ? find_layout(layout->string) : -1;
    gsf_destroy_json(ctx, &json);
    if (result == GSF_OK && kind < 0) result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid \"layout\"", path);
    if (result == GSF_OK && !(stops >= 0.0 && stops <= 8.0))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid \"drift\"", path);
    if (result == GSF_OK && !(values[0] >= 16.0 && values[1] >= 16.0 && values[0] <= 8192.0 && values[1] <= 8192.0))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: %g x %g", path, values[0], values[1]);
    *o = make_scene_defaults;
    o->width = (int)values[0];
    o->height = (int)values[1];
    o->seed = (uint64_t)values[2];
    o->drift = stops;
    o->layout = kind < 0 ? 0 : kind;
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
        s.pixel_angle =
            angle * (float)(focal_of(&s) * o.width / list[i].fx);  // texture detail for the pixel size of this camera
        result = render_camera(ctx, &s, list + i, i, exposure_of(&o, i), out);
        ok = result == GSF_OK;
    }
    if (result != GSF_OK)
        fprintf(stderr, "make_scene: %s\n", result == GSF_ERROR_OUT_OF_MEMORY ? "out of memory" : ctx->error);
    gsf_free(ctx, list);
    end_world(&s);
    return ok ? 0 : 1;
}

// ---- contact sheet ---------------------------------------------------------------

static make_scene_options options_of_seed(make_scene_options o, uint64_t seed) { // the layouts take turns
    o.seed = seed;
    o.layout = 1 + (int)((seed + (LAYOUTS - 2)) % (LAYOUTS - 1));
    return o;
}

enum { SHEET_COLUMNS = 10, SHEET_WIDTH = 160, SHEET_HEIGHT = 120 };

// Mean difference of two photos on the sheet, blurred to 16 x 12, so that neither noise nor a small shift counts.
static double sheet_difference(const uint8_t* sheet, size_t a, size_t b) {
    enum { CELL = 10 };
    const size_t stride = 3 * SHEET_COLUMNS * SHEET_WIDTH;
    const uint8_t *p = sheet + a / SHEET_COLUMNS * SHEET_HEIGHT * stride + a % SHEET_COLUMNS * SHEET_WIDTH * 3,
                  *q = sheet + b / SHEET_COLUMNS * SHEET_HEIGHT * stride + b % SHEET_COLUMNS * SHEET_WIDTH * 3;
    double sum = 0.0;
    for (size_t y = 0; y < SHEET_HEIGHT; y += CELL)
        for (size_t x = 0; x < 3 * SHEET_WIDTH; x += 3 * CELL)
            for (size_t k = 0; k < 3; k++) {
                int cell = 0;
                for (size_t i = 0; i < CELL * CELL; i++) {
                    const size_t at = (y + i / CELL) * stride + x + 3 * (i % CELL) + k;
                    cell += (int)p[at] - (int)q[at];
                }
                sum += fabs(cell / (double)(CELL * CELL));
            }
    return sum / (3.0 * SHEET_WIDTH * SHEET_HEIGHT / (CELL * CELL));
}

// One photo of each of the scenes of seeds 1 to `count`. Returns 0, or 1 after printing the error.
static int make_sheet(gsf_context* ctx, int count, const char* path) {
    const int rows = (count + SHEET_COLUMNS - 1) / SHEET_COLUMNS;
    const size_t pixels = (size_t)SHEET_WIDTH * SHEET_HEIGHT, stride = 3 * SHEET_COLUMNS * SHEET_WIDTH;
    uint8_t *sheet = (uint8_t*)gsf_alloc_zeroed(ctx, stride, (size_t)rows * SHEET_HEIGHT),
            *photo = (uint8_t*)gsf_alloc(ctx, pixels, 3);
    float* truth = (float*)gsf_alloc(ctx, pixels, 4 * sizeof(float));
    double least = INFINITY;
    int pair[2] = {1, 1}, ok = sheet && photo && truth;
    if (!ok) fprintf(stderr, "make_scene: out of memory\n");
    for (int i = 0; ok && i < count; i++) {
        world s;
        make_scene_options o = options_of_seed(make_scene_defaults, (uint64_t)i + 1);
        o.width = SHEET_WIDTH, o.height = SHEET_HEIGHT, o.views = 9;
        memset(&s, 0, sizeof s);
        ok = start_world(ctx, &s, &o);
        if (ok) {
            photo_job job = {&s, camera_of(&s, &o, 4), 4, photo, truth, truth + pixels, 1.0f};
            ctx->parallel.for_fn(ctx->parallel.user, SHEET_HEIGHT, photo_row, &job);
        }
        end_world(&s);
        uint8_t* to =
            sheet + (size_t)(i / SHEET_COLUMNS) * SHEET_HEIGHT * stride + (size_t)(i % SHEET_COLUMNS) * SHEET_WIDTH * 3;
        for (size_t y = 0; ok && y < SHEET_HEIGHT; y++)
            memcpy(to + y * stride, photo + y * 3 * SHEET_WIDTH, 3 * SHEET_WIDTH);
        for (int k = 0; ok && k < i; k++) {
            const double difference = sheet_difference(sheet, (size_t)i, (size_t)k);
            if (difference < least) least = difference, pair[0] = k + 1, pair[1] = i + 1;
        }
        if (isatty(2)) fprintf(stderr, "\rmake_scene: scene %d of %d%s", i + 1, count, i + 1 == count ? "\n" : "");
    }
    if (ok) {
        const gsf_image image = gsf_wrap_image(sheet, GSF_U8, SHEET_COLUMNS * SHEET_WIDTH, rows * SHEET_HEIGHT, 3);
        ok = gsf_save_image(ctx, path, &image) == GSF_OK;
        if (!ok) fprintf(stderr, "make_scene: %s\n", ctx->error);
    }
    if (ok && count > 1)
        printf("%d scenes; the most alike, %d and %d, differ by %.1f of 255\n", count, pair[0], pair[1], least);
    gsf_free(ctx, sheet);
    gsf_free(ctx, photo);
    gsf_free(ctx, truth);
    return ok ? 0 : 1;
}

// ---- command line ----------------------------------------------------------------

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
    fprintf(to,
            "usage: make_scene OUT [--layout NAME|any] [--seed 1] [--views 40] [--width 320] [--height 240] [--points 10000]\n"
            "       [--noise 0.5] [--arc 150] [--drift 0]\n"
            "Writes a ray-traced scene as photos with a COLMAP model and ground truth into the folder OUT.\n"
            "       make_scene OUT --scene NAME [...]\n"
            "One of the %d scenes of the benchmark; make_scene --suite lists their names.\n"
            "       make_scene SCENE --render CAMERAS.json --out PICTURES\n"
            "Renders an existing scene from other cameras into the folder PICTURES.\n"
            "       make_scene --sheet N --out SHEET.png\n"
            "A photo of each of N scenes.\n", SUITE);
    if (to != stdout) return 2;
    fprintf(to, "\nLayouts, the way of the camera, scenes of the benchmark:\n");
    for (int i = 0; i < LAYOUTS; i++) {
        fprintf(to, "  %-12s %-15s %s", layouts[i].name, layouts[i].capture, layouts[i].about);
        for (int k = 0, first = 1; k < SUITE; k++)
            if (strcmp(suite[k].layout, layouts[i].name) == 0)
                fprintf(to, first ? "\n%31s%s" : "%s%s", first ? "" : ", ", suite[k].name), first = 0;
        fprintf(to, "\n");
    }
    return 0;
}

// Sets what a name says. Returns 0 if there is no such layout or scene.
static int set_layout(make_scene_options* o, const char* name, int* any) {
    *any = strcmp(name, "any") == 0;
    const int found = *any ? 0 : find_layout(name);
    if (found >= 0) o->layout = found;
    else fprintf(stderr, "make_scene: --layout %s: no such layout (see --help)\n", name);
    return found >= 0;
}
static int set_scene(make_scene_options* o, const char* name) {
    for (int i = 0; i < SUITE; i++) {
        if (strcmp(suite[i].name, name) != 0) continue;
        o->layout = find_layout(suite[i].layout);
        o->seed = (uint64_t)suite[i].seed;
        o->drift = suite[i].drift;
        if (suite[i].arc > 0.0) o->arc = suite[i].arc;
        return 1;
    }
    fprintf(stderr, "make_scene: --scene %s: no such scene (see --suite)\n", name);
    return 0;
}

int main(int argc, char** argv) {
    make_scene_options o = make_scene_defaults;
    const char *folder = NULL, *cameras = NULL, *pictures = NULL;
    int sheet = 0, any = 0;
    for (int i = 1; i < argc; i++) {
        if (strcmp(argv[i], "--help") == 0) return usage(stdout);
        if (strcmp(argv[i], "--suite") == 0) {
            for (int k = 0; k < SUITE; k++) puts(suite[k].name);
            return 0;
        }
        if (argv[i][0] != '-') {
            if (folder) return usage(stderr);
            folder = argv[i];
            continue;
        }
        if (i + 1 >= argc) return usage(stderr);
        const char *name = argv[i], *value = argv[++i];
        if (strcmp(name, "--render") == 0) cameras = value;
        else if (strcmp(name, "--out") == 0) pictures = value;
        else if (strcmp(name, "--layout") == 0) { if (!set_layout(&o, value, &any)) return 2; }
        else if (strcmp(name, "--scene") == 0) { if (!set_scene(&o, value)) return 2; }
        else {
            char* end = NULL;
            const double x = strtod(value, &end);
            if (end == value || *end || !(x >= 0.0 && x < 1e9)) return usage(stderr);
            if (strcmp(name, "--views") == 0) o.views = (int)x;
            else if (strcmp(name, "--width") == 0) o.width = (int)x;
            else if (strcmp(name, "--height") == 0) o.height = (int)x;
            else if (strcmp(name, "--points") == 0) o.points = (int)x;
            else if (strcmp(name, "--seed") == 0) o.seed = (uint64_t)x;
            else if (strcmp(name, "--noise") == 0) o.noise = x;
            else if (strcmp(name, "--arc") == 0) o.arc = x;
            else if (strcmp(name, "--drift") == 0) o.drift = x;
            else if (strcmp(name, "--sheet") == 0 && x >= 1.0 && x <= 1000.0) sheet = (int)x;
            else return usage(stderr);
        }
    }
    if (any) o = options_of_seed(o, o.seed);
    if (sheet ? folder || cameras || !pictures : !folder || !cameras != !pictures) return usage(stderr);
    if (o.views < 2 || o.views > 999 || o.width < 16 || o.height < 16 || o.width > 8192 || o.height > 8192 ||
        o.points < 1 || o.arc > 360.0 || o.drift > 8.0)
        return usage(stderr);
    if (pictures && !is_vacant(pictures)) {
        fprintf(stderr, "make_scene: %s: already exists (choose a new %s)\n", pictures, sheet ? "file" : "folder");
        return 1;
    }
    if (!pictures && !is_vacant(folder) && !is_made_scene(folder)) {
        fprintf(stderr, "make_scene: %s: already exists and was not written by make_scene (choose a new folder)\n",
                folder);
        return 1;
    }
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK) {
        fprintf(stderr, "make_scene: %s\n", ctx.error);
        return 1;
    }
    if (sheet) return make_sheet(&ctx, sheet, pictures);
    return cameras ? render_scene(&ctx, folder, cameras, pictures) : make_scene(&ctx, &o, folder);
}

#endif // MAKE_SCENE_NO_MAIN
