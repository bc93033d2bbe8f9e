// gsfix_exec.c - the restorer exec: an external program, run as COMMAND JOBDIR for each window
// SPDX-License-Identifier: MIT
#include "gsfix.h"

/* Contents of JOBDIR before the call:
       frames/%05d.png    rendered frames
       depth/%05d.npy     float32 (height,width) camera depth, 0 = nothing there
       alpha/%05d.png     1 - transmittance
       cameras.json       cameras of the frames; a frame that has a photo's pose is named after it ("refs/00002.png")
       refs/%05d.png      the photos; refs/cameras.json; where known, refs/depth/%05d.npy and refs/render/%05d.png (the
                          splats rendered from the photo's camera)
   COMMAND writes, and exits with status 0:
       out/%05d.png         one per frame, of the same size
       confidence/%05d.png  optional, for all frames or for none: white = full weight (none: full weight everywhere)
   COMMAND is run by the shell; its standard output is redirected to stderr.
   JOBDIR is new in each round and removed afterwards with all its contents, except after a failure.
   On Windows the shell is cmd.exe. */
typedef struct exec_state {
    gsfix_app* app;
    char* name; // "exec: COMMAND"
    const char* job;
    double timeout;
    int failed;
    gsfix_process process;
} exec_state;

enum { EXEC_PREFIX = sizeof "exec: " - 1 };

static gsf_result exec_query(void* user, gsf_context* ctx, int32_t frame_count, int32_t width, int32_t height,
                             gsf_restorer_info* out) {
    (void)user, (void)ctx, (void)frame_count, (void)width, (void)height;
    out->needs_depth = 1;
    out->needs_alpha = 1;
    return GSF_OK;
}

static gsf_result exec_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    exec_state* e = (exec_state*)user;
    gsf_result result = gsfix_make_job(e->app, &e->job);
    e->failed = 0;
    gsf_camera* cameras = (gsf_camera*)gsf_alloc(ctx, (size_t)count + 1, sizeof *cameras);
    if (!cameras) return GSF_ERROR_OUT_OF_MEMORY;
    int known = count > 0;
    for (int32_t i = 0; i < count && result == GSF_OK; i++) {
        cameras[i] = references[i].camera;
        known &= cameras[i].width > 0;
        result = gsf_save_image(ctx, gsfix_pathf("%s/refs/%05d.png", e->job, (int)i).s, &references[i].color);
        if (result == GSF_OK && references[i].render.data)
            result = gsf_save_image(ctx, gsfix_pathf("%s/refs/render/%05d.png", e->job, (int)i).s, &references[i].render);
        if (result == GSF_OK && references[i].depth.data)
            result = gsfix_save_npy(ctx, gsfix_pathf("%s/refs/depth/%05d.npy", e->job, (int)i).s, &references[i].depth);
    }
    if (result == GSF_OK && known)
        result = gsf_save_cameras(ctx, gsfix_pathf("%s/refs/cameras.json", e->job).s, cameras, NULL, (size_t)count);
    gsf_free(ctx, cameras);
    if (result != GSF_OK) gsfix_leave_job(e->app, 1);
    return result;
}

static void exec_end(void* user, gsf_context* ctx) { // after a failure the job folder is kept for diagnosis
    const exec_state* e = (const exec_state*)user;
    (void)ctx;
    gsfix_leave_job(e->app, !e->failed);
}

static gsf_result write_cameras(gsf_context* ctx, const exec_state* e, const gsf_restore_window* w) {
    const size_t n = (size_t)w->frame_count;
    gsfix_path* names = (gsfix_path*)gsf_alloc(ctx, n, sizeof *names);
    const char** pointers = (const char**)gsf_alloc(ctx, n, sizeof *pointers);
    gsf_result result = names && pointers ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < n && result == GSF_OK; i++) {
        const int32_t reference = w->reference_index ? w->reference_index[i] : -1;
        names[i] = reference >= 0 ? gsfix_pathf("refs/%05d.png", (int)reference) : gsfix_pathf("frames/%05zu.png", i);
        pointers[i] = names[i].s;
    }
    if (result == GSF_OK)
        result = gsf_save_cameras(ctx, gsfix_pathf("%s/cameras.json", e->job).s, w->cameras, pointers, n);
    gsf_free(ctx, (void*)pointers);
    gsf_free(ctx, names);
    return result;
}

static gsf_result write_job(gsf_context* ctx, exec_state* e, const gsf_restore_window* w) {
    static const char* const folders[] = {"frames", "depth", "alpha", "out", "confidence"};
    gsf_result result = GSF_OK;
    for (size_t k = 0; k < sizeof folders / sizeof *folders && result == GSF_OK; k++)
        result = gsfix_empty_job(e->app, folders[k]);
    for (int32_t i = 0; i < w->frame_count && result == GSF_OK; i++) {
        result = gsf_save_image(ctx, gsfix_pathf("%s/frames/%05d.png", e->job, (int)i).s, w->color + i);
        if (result == GSF_OK && w->depth)
            result = gsfix_save_npy(ctx, gsfix_pathf("%s/depth/%05d.npy", e->job, (int)i).s, w->depth + i);
        if (result == GSF_OK && w->alpha)
            result = gsf_save_image(ctx, gsfix_pathf("%s/alpha/%05d.png", e->job, (int)i).s, w->alpha + i);
    }
    return result == GSF_OK && w->cameras ? write_cameras(ctx, e, w) : result;
}

#ifdef _WIN32
// cmd.exe removes the outer quotes only (/s) and runs no start-up script (/d).
static gsf_result start_program(gsf_context* ctx, exec_state* e) {
    gsf_buffer line = {0};
    gsfix_path job = gsfix_pathf("%s", e->job); // the shell's own commands take slashes for options
    for (char* c = job.s; *c; c++)
        if (*c == '/') *c = '\\';
    gsf_append_text(ctx, &line, "cmd.exe /d /s /c \"%s \"%s\"\"", e->name + EXEC_PREFIX, job.s);
    const char* const arguments[] = {line.data, NULL};
    const gsf_result result = line.failed ? GSF_ERROR_OUT_OF_MEMORY : gsfix_start_process(ctx, &e->process, arguments, 0);
    gsf_destroy_buffer(ctx, &line);
    return result;
}
#else
static gsf_result start_program(gsf_context* ctx, exec_state* e) {
    gsf_buffer script = {0};
    gsf_append_text(ctx, &script, "%s \"$@\"", e->name + EXEC_PREFIX);
    const char* const arguments[] = {"/bin/sh", "-c", script.data, "sh", e->job, NULL};
    const gsf_result result = script.failed ? GSF_ERROR_OUT_OF_MEMORY : gsfix_start_process(ctx, &e->process, arguments, 0);
    gsf_destroy_buffer(ctx, &script);
    return result;
}
#endif

static gsf_result run_program(gsf_context* ctx, exec_state* e) {
    const gsf_result result = start_program(ctx, e);
    return result == GSF_OK ? gsfix_wait_process(ctx, &e->process, e->timeout) : result;
}

static gsf_result read_result(gsf_context* ctx, const char* path, int32_t channels, const gsf_image* out) {
    gsf_image image;
    if (!gsfix_exists(path)) return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s was not written", path);
    gsf_result result = gsf_load_image(ctx, path, channels, &image);
    if (result != GSF_OK) return result;
    if (image.width != out->width || image.height != out->height)
        result = gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s is %lld x %lld, expected %lld x %lld", path,
                          (long long)image.width, (long long)image.height, (long long)out->width, (long long)out->height);
    else
        result = gsf_convert_image(ctx, &image, out);
    gsf_destroy_image(ctx, &image);
    return result;
}

static void fill_ones(gsf_image* image) {
    for (int64_t y = 0; y < image->height; y++)
        for (int64_t x = 0; x < image->width; x++)
            *(float*)(void*)((char*)image->data + y * image->stride_y + x * image->stride_x) = 1.0f;
}

static gsf_result run_job(exec_state* e, gsf_context* ctx, const gsf_restore_window* w) {
    gsf_result result = write_job(ctx, e, w);
    if (result == GSF_OK) result = run_program(ctx, e);
    if (result == GSF_OK) result = gsfix_check_job(e->app, "out");
    if (result == GSF_OK) result = gsfix_check_job(e->app, "confidence");
    int confidences = 0;
    for (int32_t i = 0; i < w->frame_count; i++)
        confidences += gsfix_exists(gsfix_pathf("%s/confidence/%05d.png", e->job, (int)i).s);
    for (int32_t i = 0; i < w->frame_count && result == GSF_OK; i++) {
        result = read_result(ctx, gsfix_pathf("%s/out/%05d.png", e->job, (int)i).s, 3, w->out_color + i);
        if (result != GSF_OK) break;
        if (confidences)
            result =
                read_result(ctx, gsfix_pathf("%s/confidence/%05d.png", e->job, (int)i).s, 1, w->out_confidence + i);
        else fill_ones(w->out_confidence + i);
    }
    return result;
}

static gsf_result exec_restore(void* user, gsf_context* ctx, const gsf_restore_window* w) {
    exec_state* e = (exec_state*)user;
    const gsf_result result = run_job(e, ctx, w);
    if (result == GSF_OK || result == GSF_ERROR_CANCELLED) return result;
    char why[sizeof ctx->error];
    memcpy(why, ctx->error, sizeof why);
    e->failed = 1;
    return gsf_fail(ctx, result, "%.300s (kept: %s)", why, e->job);
}

static void exec_destroy(void* user, gsf_context* ctx) {
    exec_state* e = (exec_state*)user;
    gsfix_end_process(&e->process);
    gsf_free(ctx, e->name);
    gsf_free(ctx, e);
}

gsf_result gsfix_make_exec(gsfix_app* app, const char* command, double timeout, gsf_restorer* out) {
    gsf_context* ctx = &app->ctx;
    memset(out, 0, sizeof *out);
    exec_state* e = (exec_state*)gsf_alloc_zeroed(ctx, 1, sizeof *e);
    if (!e) return GSF_ERROR_OUT_OF_MEMORY;
    e->app = app;
    const gsfix_path name = gsfix_pathf("exec: %s", command);
    e->name = gsfix_copy_text(ctx, name.s, strlen(name.s));
    e->process.name = e->name;
    e->process.code = GSF_ERROR_RESTORER;
    e->timeout = timeout;
    out->struct_size = sizeof *out;
    out->name = "exec";
    out->user = e;
    out->query_fn = exec_query;
    out->begin_fn = exec_begin;
    out->restore_fn = exec_restore;
    out->end_fn = exec_end;
    out->destroy_fn = exec_destroy;
    if (e->name) return GSF_OK;
    gsf_destroy_restorer(ctx, out);
    return GSF_ERROR_OUT_OF_MEMORY;
}
