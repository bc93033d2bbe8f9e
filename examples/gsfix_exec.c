// gsfix_exec.c - a restorer that is another program: COMMAND JOBDIR for each window
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <errno.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

/* JOBDIR, before the call:
       frames/%05d.png    rendered frames
       depth/%05d.npy     float32 (height,width) camera depth, 0 = nothing there
       alpha/%05d.png     1 - transmittance
       cameras.json       cameras of the frames; a frame that is a photo's view is named after it ("refs/00002.png")
       refs/%05d.png      the photos; refs/cameras.json; refs/depth/%05d.npy and refs/render/%05d.png (what the
                          splats show there) where known
   and what COMMAND leaves there with exit status 0:
       out/%05d.png         as many and as large as frames/
       confidence/%05d.png  optional, for all frames or for none: white = trust the pixel (none: all are trusted)
   COMMAND goes through the shell; what it prints goes to stderr. */
typedef struct exec_state {
    char* command;
    char* job;
    double timeout;
    int failed;
} exec_state;

static gsf_result exec_query(void* user, gsf_context* ctx, int32_t frame_count, int32_t width, int32_t height,
                             gsf_restorer_limits* out) {
    (void)user, (void)ctx, (void)frame_count, (void)width, (void)height;
    memset(out, 0, sizeof *out);
    out->needs_depth = 1;
    out->needs_alpha = 1;
    return GSF_OK;
}

static gsf_result exec_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    const exec_state* e = (const exec_state*)user;
    gsf_result result = gsfix_clear_folder(ctx, e->job, 1);
    if (result == GSF_OK) result = gsfix_make_folder(ctx, gsfix_pathf("%s/refs/render", e->job).s);
    if (result == GSF_OK) result = gsfix_make_folder(ctx, gsfix_pathf("%s/refs/depth", e->job).s);
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
    return result;
}

static void exec_end(void* user, gsf_context* ctx) { // after a failure the job stays, for whoever looks for the cause
    const exec_state* e = (const exec_state*)user;
    if (!e->failed && gsfix_clear_folder(ctx, e->job, 1) == GSF_OK) rmdir(e->job);
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

static gsf_result write_job(gsf_context* ctx, const exec_state* e, const gsf_restore_window* w) {
    static const char* const folders[] = {"frames", "depth", "alpha", "out", "confidence"};
    gsf_result result = GSF_OK;
    for (size_t k = 0; k < sizeof folders / sizeof *folders && result == GSF_OK; k++) {
        const gsfix_path folder = gsfix_pathf("%s/%s", e->job, folders[k]);
        result = gsfix_clear_folder(ctx, folder.s, 1);
        if (result == GSF_OK) result = gsfix_make_folder(ctx, folder.s);
    }
    for (int32_t i = 0; i < w->frame_count && result == GSF_OK; i++) {
        result = gsf_save_image(ctx, gsfix_pathf("%s/frames/%05d.png", e->job, (int)i).s, w->color + i);
        if (result == GSF_OK && w->depth)
            result = gsfix_save_npy(ctx, gsfix_pathf("%s/depth/%05d.npy", e->job, (int)i).s, w->depth + i);
        if (result == GSF_OK && w->alpha)
            result = gsf_save_image(ctx, gsfix_pathf("%s/alpha/%05d.png", e->job, (int)i).s, w->alpha + i);
    }
    return result == GSF_OK && w->cameras ? write_cameras(ctx, e, w) : result;
}

static void stop_group(pid_t group) { // it has a second to leave
    kill(-group, SIGTERM);
    for (int i = 0; i < 50; i++) {
        const struct timespec pause = {0, 20000000};
        if (waitpid(group, NULL, WNOHANG) == group) {
            kill(-group, SIGKILL); // what it may have started and left behind
            return;
        }
        nanosleep(&pause, NULL);
    }
    kill(-group, SIGKILL);
    waitpid(group, NULL, 0);
}

static gsf_result run_program(gsf_context* ctx, const exec_state* e) {
    const gsfix_path script = gsfix_pathf("%s \"$@\"", e->command);
    if (strlen(script.s) + 1 >= sizeof script.s) return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: the command is too long");
    fflush(NULL);
    const pid_t child = fork();
    if (child < 0) return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: no new process: %s", strerror(errno));
    if (child == 0) {
        setpgid(0, 0); // so that all of it can be stopped at once
        signal(SIGINT, SIG_DFL);
        signal(SIGTERM, SIG_DFL);
        dup2(2, 1); // stdout is for --json
        execl("/bin/sh", "sh", "-c", script.s, "sh", e->job, (char*)NULL);
        _exit(127);
    }
    setpgid(child, child); // whoever comes first
    const double begin = gsfix_now();
    for (;;) {
        int status = 0;
        const pid_t ended = waitpid(child, &status, WNOHANG);
        if (ended < 0 && errno != EINTR) return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: waitpid: %s", strerror(errno));
        if (ended == child) {
            if (WIFEXITED(status) && WEXITSTATUS(status) == 0) return GSF_OK;
            if (WIFSIGNALED(status))
                return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s was ended by signal %d", e->command, WTERMSIG(status));
            return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s %s ended with status %d", e->command, e->job,
                            WEXITSTATUS(status));
        }
        const int cancelled = gsf_is_cancelled(ctx);
        if (cancelled || gsfix_now() - begin > e->timeout) {
            stop_group(child);
            return cancelled ? gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled")
                             : gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s took longer than %g s and was stopped",
                                        e->command, e->timeout);
        }
        const struct timespec pause = {0, 10000000};
        nanosleep(&pause, NULL);
    }
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

static gsf_result exec_restore(void* user, gsf_context* ctx, const gsf_restore_window* w) {
    exec_state* e = (exec_state*)user;
    gsf_result result = write_job(ctx, e, w);
    if (result == GSF_OK) result = run_program(ctx, e);
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
    e->failed = result != GSF_OK && result != GSF_ERROR_CANCELLED;
    return result;
}

gsf_result gsfix_make_exec(gsf_context* ctx, const char* command, const char* job, double timeout, gsf_restorer* out) {
    memset(out, 0, sizeof *out);
    exec_state* e = (exec_state*)gsf_alloc_zeroed(ctx, 1, sizeof *e);
    if (!e) return GSF_ERROR_OUT_OF_MEMORY;
    e->command = gsfix_copy_text(ctx, command, strlen(command));
    e->timeout = timeout;
    char* absolute = gsfix_make_folder(ctx, job) == GSF_OK ? realpath(job, NULL) : NULL; // COMMAND may change its folder
    if (absolute) e->job = gsfix_copy_text(ctx, absolute, strlen(absolute));
    free(absolute);
    out->struct_size = sizeof *out;
    out->name = "exec";
    out->user = e;
    out->query_fn = exec_query;
    out->begin_fn = exec_begin;
    out->restore_fn = exec_restore;
    out->end_fn = exec_end;
    if (e->command && e->job) return GSF_OK;
    gsfix_destroy_exec(ctx, out);
    return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s: folder cannot be used", job);
}

void gsfix_destroy_exec(gsf_context* ctx, gsf_restorer* restorer) {
    exec_state* e = (exec_state*)restorer->user;
    if (!e) return;
    gsf_free(ctx, e->command);
    gsf_free(ctx, e->job);
    gsf_free(ctx, e);
    memset(restorer, 0, sizeof *restorer);
}
