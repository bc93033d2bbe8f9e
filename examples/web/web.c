// web.c - the library behind the page of examples/web, as WebAssembly. Built by build.sh; page.js calls the functions below in
// a worker, one at a time.
// SPDX-License-Identifier: MIT
/* Files come as bytes, dropped onto the page or made here: the library finds them through the hooks of gsf_io, by the end of
   their path, so that a folder may be dropped with or without its parents. */
#define JOB_SYSTEM_ONLY
#include "../job_system.c"
#define MAKE_SCENE_NO_MAIN
#include "../make_scene.c"

#include <emscripten.h>

#include "../gsfix_orbit.h"

enum { MEASURE_EVERY = 25, FILES_MAX = 4096 };

typedef struct web_file { char* path; void* data; size_t size; } web_file;

static struct web {
    gsf_context ctx;
    job_system jobs;
    web_file files[FILES_MAX];
    size_t file_count;
    // a scene that is being made
    world made;
    make_scene_options options;
    cloud points;
    uint8_t* photos[64];
    float* truth; // depth and normals, which nobody asks for
    // what is shown
    gsf_splats splats;
    gsf_scene scene;
    uint32_t *train, *test; // indices of views
    size_t train_count, test_count;
    gsf_train_view* views;
    gsf_restorer warp;
    gsf_fixer* fixer;
    gsf_fix_stats stats;
    gsf_train_stats last;
    int32_t iterations;
    double psnr; // mean over the photos that are not trained on, after `measured` iterations
    int32_t measured;
    gsf_rasterizer* rasterizer;
    gsf_render_desc desc;
    gsfix_orbit at;
    gsf_buffer text; // of the answers
    gsf_image color, bytes;
} w;

// ---- files -----------------------------------------------------------------------

static int web_ends_with(const char* path, const char* end) { // at a whole name
    const size_t length = strlen(path), size = strlen(end);
    return length >= size && strcmp(path + length - size, end) == 0 && (length == size || path[length - size - 1] == '/');
}

static const web_file* web_find(const char* path) {
    const char* name = strrchr(path, '/');
    const char* below = strncmp(path, "scene/", 6) == 0 ? path + 6 : path;
    for (size_t i = 0; i < w.file_count; i++)
        if (web_ends_with(w.files[i].path, below)) return w.files + i;
    if (strstr(path, "/masks/")) return NULL; // a mask may have a photo's name
    for (size_t i = 0; i < w.file_count; i++)
        if (!strstr(w.files[i].path, "masks/") && web_ends_with(w.files[i].path, name ? name + 1 : path)) return w.files + i;
    return NULL;
}

static gsf_result web_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    const web_file* file = web_find(path);
    (void)user;
    if (!file) return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: not among the files", path);
    *data = gsf_alloc(ctx, file->size + 1, 1);
    if (!*data) return GSF_ERROR_OUT_OF_MEMORY;
    memcpy(*data, file->data, file->size);
    *size = file->size;
    return GSF_OK;
}

// Room for a file of this size, which the caller fills in. NULL: out of memory, or too many.
EMSCRIPTEN_KEEPALIVE void* web_add_file(const char* path, size_t size) {
    if (w.file_count == FILES_MAX) return NULL;
    web_file* file = w.files + w.file_count;
    file->path = (char*)gsf_alloc(&w.ctx, strlen(path) + 1, 1);
    file->data = gsf_alloc(&w.ctx, size + 1, 1);
    if (!file->path || !file->data) {
        gsf_free(&w.ctx, file->path);
        gsf_free(&w.ctx, file->data);
        return NULL;
    }
    strcpy(file->path, path);
    file->size = size;
    w.file_count++;
    return file->data;
}

static gsf_result web_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    void* to = web_add_file(path, size);
    (void)user, (void)ctx;
    if (!to) return GSF_ERROR_OUT_OF_MEMORY;
    memcpy(to, data, size);
    return GSF_OK;
}

EMSCRIPTEN_KEEPALIVE void web_forget_files(void) {
    for (size_t i = 0; i < w.file_count; i++) {
        gsf_free(&w.ctx, w.files[i].path);
        gsf_free(&w.ctx, w.files[i].data);
    }
    w.file_count = 0;
}

// ---- start and end -----------------------------------------------------------------

// 0, or an error that web_error() tells.
EMSCRIPTEN_KEEPALIVE int web_start(int threads) {
    w.ctx.io.read_fn = web_read;
    w.ctx.io.write_fn = web_write;
#ifdef __EMSCRIPTEN_PTHREADS__
    if (threads > 1 && job_start(&w.jobs, threads < JOB_WORKERS_MAX ? threads : JOB_WORKERS_MAX)) {
        w.ctx.parallel.for_fn = job_for;
        w.ctx.parallel.user = &w.jobs;
        w.ctx.parallel.worker_count = w.jobs.worker_count;
    }
#else
    (void)threads, (void)job_start, (void)job_for;
#endif
    gsf_result result = gsf_init_context(&w.ctx);
    if (result == GSF_OK) result = gsf_splat_make_rasterizer(&w.ctx, &w.rasterizer);
    return (int)result;
}

EMSCRIPTEN_KEEPALIVE const char* web_error(void) { return w.ctx.error; }

static void web_close(void) {
    gsf_context* ctx = &w.ctx;
    gsf_splat_destroy_fixer(ctx, w.fixer);
    gsf_destroy_restorer(ctx, &w.warp);
    gsf_free(ctx, w.views);
    gsf_free(ctx, w.train);
    gsf_splat_destroy_scene(ctx, &w.scene);
    gsf_splat_destroy(ctx, &w.splats);
    w.fixer = NULL;
    w.views = NULL;
    w.train = w.test = NULL;
    w.train_count = w.test_count = 0;
    memset(&w.stats, 0, sizeof w.stats);
    memset(&w.last, 0, sizeof w.last);
    memset(&w.desc, 0, sizeof w.desc);
}

// ---- made scenes -------------------------------------------------------------------

// Number of photos to come, or 0: out of memory.
EMSCRIPTEN_KEEPALIVE int web_make_begin(int layout, int seed, int views, double arc, int width, int height) {
    web_forget_files();
    w.options = make_scene_defaults;
    w.options.layout = layout < 0 || layout >= LAYOUTS ? 0 : layout;
    w.options.seed = (uint64_t)seed;
    w.options.views = views < 2 ? 2 : views < 64 ? views : 64;
    w.options.arc = arc;
    w.options.width = width;
    w.options.height = height;
    w.options.points = 3000;
    memset(&w.made, 0, sizeof w.made);
    memset(&w.points, 0, sizeof w.points);
    w.points.scene.view_count = (size_t)w.options.views;
    w.points.scene.views = (gsf_scene_view*)gsf_alloc_zeroed(&w.ctx, (size_t)w.options.views, sizeof(gsf_scene_view));
    w.truth = (float*)gsf_alloc(&w.ctx, (size_t)(width * height), 4 * sizeof(float));
    return w.points.scene.views && w.truth && start_world(&w.ctx, &w.made, &w.options) ? w.options.views : 0;
}

// Takes photo i and returns its pixels, RGB; NULL: out of memory.
EMSCRIPTEN_KEEPALIVE const uint8_t* web_make_photo(int i) {
    const size_t pixels = (size_t)w.options.width * (size_t)w.options.height;
    gsf_scene_view* view = w.points.scene.views + i;
    char path[64];
    view->image_id = (uint32_t)i + 1;
    view->camera = camera_of(&w.made, &w.options, i);
    view->name = (char*)gsf_alloc(&w.ctx, 32, 1);
    w.photos[i] = (uint8_t*)gsf_alloc(&w.ctx, pixels, 3);
    if (!view->name || !w.photos[i]) return NULL;
    snprintf(view->name, 32, "frame_%03d.png", i + 1);
    photo_job job = {&w.made, view->camera, (uint64_t)i, w.photos[i], w.truth, w.truth + pixels, 1.0f};
    w.ctx.parallel.for_fn(w.ctx.parallel.user, (size_t)w.options.height, photo_row, &job);
    const gsf_image image = gsf_wrap_image(w.photos[i], GSF_U8, w.options.width, w.options.height, 3);
    snprintf(path, sizeof path, "scene/images/%s", view->name);
    return gsf_save_image(&w.ctx, path, &image) == GSF_OK ? w.photos[i] : NULL;
}

// Finds the points; the scene's files are then there as if dropped.
EMSCRIPTEN_KEEPALIVE int web_make_end(void) {
    gsf_scene* s = &w.points.scene;
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    if (find_points(&w.ctx, &w.made, &w.options, w.photos, &w.points))
        result = gsf_splat_save_colmap(&w.ctx, s, NULL, "scene");
    void* const blocks[] = {s->points, s->colors, s->point_ids, s->track_begin, s->track_views, w.points.truth,
                            w.points.outlier, w.truth};
    for (size_t i = 0; i < sizeof blocks / sizeof *blocks; i++) gsf_free(&w.ctx, blocks[i]);
    for (size_t i = 0; i < s->view_count; i++) {
        gsf_free(&w.ctx, s->views[i].name);
        gsf_free(&w.ctx, w.photos[i]);
    }
    gsf_free(&w.ctx, s->views);
    end_world(&w.made);
    return (int)result;
}

// ---- opening -----------------------------------------------------------------------

static gsf_result web_open_splats(const web_file* file, int width, int height) {
    double radius = 1.0;
    gsf_result result;
#ifndef GSF_USE_ZSTD // Debian has no zstd for WebAssembly
    const size_t length = strlen(file->path);
    if (length > 4 && strcmp(file->path + length - 4, ".spz") == 0 && file->size > 4 && memcmp(file->data, "NGSP", 4) == 0)
        return gsf_fail(&w.ctx, GSF_ERROR_UNSUPPORTED, "%s: SPZ 4 needs zstd, and this page is built without it; "
                        "gsfix convert FILE.spz --out FILE.glb makes a file that it reads", file->path);
#endif
    result = gsf_splat_parse(&w.ctx, file->path, file->data, file->size, &w.splats);
    if (result == GSF_OK && !w.splats.count) result = gsf_fail(&w.ctx, GSF_ERROR_DEGENERATE, "%s: no splats", file->path);
    if (result == GSF_OK) result = orbit_face(&w.ctx, &w.at, &w.splats, width, height, &radius);
    w.desc.near_plane = (float)(0.02 * radius);
    w.desc.antialiased = w.splats.antialiased;
    memcpy(w.desc.background, w.splats.background, sizeof w.desc.background);
    return result;
}

// Every 8th photo is held out; of the others, `photos` are trained on (0: all).
static gsf_result web_split(size_t photos) {
    const size_t n = w.scene.view_count, room = n > photos ? n : photos;
    w.train = (uint32_t*)gsf_alloc(&w.ctx, room + n, sizeof *w.train);
    if (!w.train) return GSF_ERROR_OUT_OF_MEMORY;
    w.test = w.train + room;
    gsf_splat_split_views(n, n > 3 ? 8 : 0, photos, w.train, &w.train_count, w.test, &w.test_count);
    return w.train_count ? GSF_OK : gsf_fail(&w.ctx, GSF_ERROR_DEGENERATE, "no photos to train on");
}

static gsf_result web_measure(void) {
    w.psnr = 0.0;
    w.measured = w.last.iteration;
    for (size_t i = 0; i < w.test_count; i++) {
        const gsf_scene_view* view = w.scene.views + w.test[i];
        gsf_render_output out = {0};
        double psnr = 0.0;
        gsf_result result = gsf_make_image(&w.ctx, GSF_F32, view->camera.width, view->camera.height, 3, &out.color);
        if (result == GSF_OK) result = gsf_splat_render_trainer(&w.ctx, gsf_splat_get_trainer(w.fixer), &view->camera, &out);
        if (result == GSF_OK)
            result = gsf_measure_image(&w.ctx, GSF_METRIC_PSNR, &out.color, &view->image, NULL, &psnr);
        gsf_destroy_image(&w.ctx, &out.color);
        if (result != GSF_OK) return result;
        w.psnr += psnr / (double)w.test_count;
    }
    return GSF_OK;
}

static gsf_result web_open_scene(int width, int height, int photos, int repair, int iterations) {
    gsf_context* ctx = &w.ctx;
    gsf_scene_desc size = {0};
    double radius;
    size.max_size = 320;
    gsf_result result = gsf_splat_load_scene(ctx, "scene", &size, &w.scene);
    if (result == GSF_OK) result = web_split((size_t)photos);
    if (result == GSF_OK) result = gsf_splat_load_train_views(ctx, &w.scene, w.train, w.train_count, &w.views);
    for (size_t i = 0; i < w.test_count && result == GSF_OK; i++)
        result = gsf_splat_load_view_image(ctx, &w.scene, w.test[i]);
    if (result == GSF_OK)
        result = gsf_splat_make_initial_splats(ctx, &w.scene, w.train, w.train_count, NULL, &w.splats, NULL);
    if (result == GSF_OK) result = orbit_set_pivot(ctx, &w.at, &w.splats, &radius);
    if (result == GSF_OK && repair) result = gsf_splat_make_warp(ctx, &w.warp);
    if (result != GSF_OK) return result;
    orbit_set_up(&w.at, w.views, w.train_count);
    orbit_from(&w.at, &w.views[0].camera, width, height);
    gsf_fix_desc desc = gsf_splat_resolve_few_view_desc(&w.scene, w.train_count, GSF_QUALITY_FAST);
    if (iterations > 0) desc.train.iterations = iterations;
    w.iterations = desc.train.iterations;
    w.desc = desc.train.render;
    result = gsf_splat_make_fixer(ctx, &desc, w.views, w.train_count, &w.splats, repair ? &w.warp : NULL, &w.fixer);
    return result == GSF_OK ? web_measure() : result;
}

// Opens what the files are, splats or a scene, to be shown at this size. photos, repair, iterations: of scenes.
EMSCRIPTEN_KEEPALIVE int web_open(int width, int height, int photos, int repair, int iterations) {
    static const char* const kinds[] = {".ply", ".spz", ".glb", ".splat"};
    const web_file* splats = NULL;
    web_close();
    for (size_t i = 0; i < w.file_count; i++)
        for (size_t k = 0; k < sizeof kinds / sizeof *kinds; k++) {
            const size_t length = strlen(w.files[i].path), size = strlen(kinds[k]);
            if (length > size && strcmp(w.files[i].path + length - size, kinds[k]) == 0) splats = w.files + i;
        }
    if (splats && w.file_count == 1) return (int)web_open_splats(splats, width, height); // else points of a transforms.json
    return (int)web_open_scene(width, height, photos, repair, iterations);
}

// ---- training ----------------------------------------------------------------------

// Works for `budget` milliseconds, at least one step, until `until` iterations are done.
EMSCRIPTEN_KEEPALIVE int web_train(double budget, int until) {
    const double begin = emscripten_get_now();
    while (w.fixer && w.stats.stage != GSF_FIX_DONE && (until <= 0 || w.last.iteration < until)) {
        gsf_result result = gsf_splat_step_fixer(&w.ctx, w.fixer, &w.stats);
        if (result == GSF_OK && w.stats.stage == GSF_FIX_TRAIN) {
            w.last = w.stats.train;
            if (w.last.iteration % MEASURE_EVERY == 0) result = web_measure();
        }
        if (result != GSF_OK) return (int)result;
        if (emscripten_get_now() - begin > budget) break;
    }
    return 0;
}

// What the page shows, as JSON.
EMSCRIPTEN_KEEPALIVE const char* web_state(void) {
    const int done = w.stats.stage == GSF_FIX_DONE, training = w.fixer && !done;
    w.text.size = 0;
    gsf_append_text(&w.ctx, &w.text,
                    "{\"splats\":%zu,\"photos\":%zu,\"heldOut\":%zu,\"iteration\":%d,\"measured\":%d,\"iterations\":%d,\"round\":%d,"
                    "\"restoring\":%d,\"training\":%d,\"done\":%d,\"threads\":%d,\"kernels\":\"%s\",\"psnr\":",
                    w.last.splats ? w.last.splats : w.splats.count, w.train_count, w.test_count, (int)w.last.iteration,
                    (int)w.measured, w.fixer ? (int)w.iterations : 0, (int)w.stats.round,
                    w.stats.stage == GSF_FIX_PLAN || w.stats.stage == GSF_FIX_RESTORE, training, w.fixer && done,
                    (int)w.ctx.parallel.worker_count, gsf_describe_cpu_level(w.ctx.cpu_level));
    gsf_append_json_number(&w.ctx, &w.text, w.psnr);
    gsf_append_text(&w.ctx, &w.text, ",\"loss\":");
    gsf_append_json_number(&w.ctx, &w.text, w.last.loss);
    gsf_append_text(&w.ctx, &w.text, "}");
    return w.text.failed ? "{}" : w.text.data;
}

// The bytes of a splat file, valid until the next call. NULL: see web_error.
EMSCRIPTEN_KEEPALIVE const char* web_save(const char* name, size_t* size) {
    const gsf_splats* splats = w.fixer ? gsf_splat_get_trained(gsf_splat_get_trainer(w.fixer)) : &w.splats;
    w.text.size = 0;
    if (gsf_splat_format(&w.ctx, name, splats, NULL, &w.text) != GSF_OK) return NULL;
    *size = w.text.size;
    return w.text.data;
}

// ---- the picture -------------------------------------------------------------------

EMSCRIPTEN_KEEPALIVE void web_orbit(double x, double y) { orbit_drag(&w.at, x, y); } // pixels of the mouse

EMSCRIPTEN_KEEPALIVE void web_pan(double x, double y) {
    const double pixel = orbit_distance(&w.at) / w.at.camera.fx;
    orbit_shift(&w.at, 0, -pixel * x, 1);
    orbit_shift(&w.at, 1, -pixel * y, 1);
}

EMSCRIPTEN_KEEPALIVE void web_zoom(double steps) { orbit_shift(&w.at, 2, 0.1 * steps * orbit_distance(&w.at), 0); }

// RGBA pixels, valid until the next picture.
static const uint8_t* web_picture(const gsf_camera* camera) {
    gsf_context* ctx = &w.ctx;
    gsf_result result = GSF_OK;
    if (w.color.width != camera->width || w.color.height != camera->height) {
        gsf_destroy_image(ctx, &w.color);
        gsf_destroy_image(ctx, &w.bytes);
        result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &w.color);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, camera->width, camera->height, 4, &w.bytes);
        if (result == GSF_OK) memset(w.bytes.data, 255, (size_t)(4 * w.bytes.width * w.bytes.height));
    }
    gsf_render_output out = {0};
    out.color = w.color;
    if (result == GSF_OK)
        result = w.fixer ? gsf_splat_render_trainer(ctx, gsf_splat_get_trainer(w.fixer), camera, &out)
                         : gsf_splat_render(ctx, w.rasterizer, &w.splats, camera, &w.desc, &out);
    gsf_image rgb = w.bytes; // without its alpha
    rgb.channels = 3;
    if (result == GSF_OK) result = gsf_convert_image(ctx, &w.color, &rgb);
    return result == GSF_OK ? (const uint8_t*)w.bytes.data : NULL;
}

EMSCRIPTEN_KEEPALIVE const uint8_t* web_render(int width, int height) {
    const gsf_camera camera = gsf_resize_camera(&w.at.camera, width, height);
    return web_picture(&camera);
}

// A photo that is not trained on (RGB), or what the splats show in its place (RGBA); width and height are written. NULL: none.
EMSCRIPTEN_KEEPALIVE const uint8_t* web_held_out(int render, int32_t* size) {
    if (!w.test_count) return NULL;
    const gsf_scene_view* view = w.scene.views + w.test[w.test_count / 2];
    size[0] = view->camera.width;
    size[1] = view->camera.height;
    return render ? web_picture(&view->camera) : (const uint8_t*)view->image.data;
}
