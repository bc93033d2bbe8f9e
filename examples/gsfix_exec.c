// gsfix_exec.c - the restorer exec: an external program, run as COMMAND JOBDIR for each window
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#define NOMINMAX
#include <windows.h>
#else
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <sys/prctl.h>
#endif
#endif

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
   COMMAND, its child processes and a watcher form one process group. The watcher blocks on a pipe whose write end only
   gsfix holds: when gsfix terminates for any reason, even kill -9, the watcher reads end of file and kills the group.
   On Windows the shell is cmd.exe, and a job object, which ends with its last handle, takes the place of group and watcher. */
typedef struct exec_state {
    gsfix_app* app;
    char* command;
    const char* job;
    double timeout;
    int failed;
#ifndef _WIN32
    pid_t group; // process group, and process ID of the watcher; 0: none
    int life;    // write end of the pipe
#endif
} exec_state;

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

// The command line for cmd.exe, which removes the outer quotes only (/s) and runs no start-up script (/d).
static wchar_t* command_line(gsf_context* ctx, const exec_state* e) {
    gsf_buffer line = {0};
    gsfix_path job = gsfix_pathf("%s", e->job); // the shell's own commands take slashes for options
    for (char* c = job.s; *c; c++)
        if (*c == '/') *c = '\\';
    gsf_append_text(ctx, &line, "cmd.exe /d /s /c \"%s \"%s\"\"", e->command, job.s);
    const int size = line.failed ? 0 : MultiByteToWideChar(CP_UTF8, 0, line.data, -1, NULL, 0);
    wchar_t* wide = size > 0 ? (wchar_t*)gsf_alloc(ctx, (size_t)size, sizeof *wide) : NULL;
    if (wide) MultiByteToWideChar(CP_UTF8, 0, line.data, -1, wide, size);
    gsf_destroy_buffer(ctx, &line);
    return wide;
}

static HANDLE make_job(void) { // all its processes end when the last handle is closed, at the latest when this process ends
    JOBOBJECT_EXTENDED_LIMIT_INFORMATION limits;
    HANDLE job = CreateJobObjectW(NULL, NULL);
    memset(&limits, 0, sizeof limits);
    limits.BasicLimitInformation.LimitFlags = JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE;
    if (job) SetInformationJobObject(job, JobObjectExtendedLimitInformation, &limits, sizeof limits);
    return job;
}

static int start_program(wchar_t* line, HANDLE job, PROCESS_INFORMATION* process) {
    STARTUPINFOW start;
    memset(&start, 0, sizeof start);
    start.cb = sizeof start;
    start.dwFlags = STARTF_USESTDHANDLES;
    start.hStdInput = GetStdHandle(STD_INPUT_HANDLE);
    start.hStdOutput = GetStdHandle(STD_ERROR_HANDLE); // stdout is reserved for --json
    start.hStdError = GetStdHandle(STD_ERROR_HANDLE);
    if (!CreateProcessW(NULL, line, NULL, NULL, TRUE, CREATE_SUSPENDED, NULL, NULL, &start, process)) return 0;
    AssignProcessToJobObject(job, process->hProcess); // before it can start others
    ResumeThread(process->hThread);
    return 1;
}

static gsf_result run_program(gsf_context* ctx, exec_state* e) {
    PROCESS_INFORMATION process;
    wchar_t* line = command_line(ctx, e);
    if (!line) return GSF_ERROR_OUT_OF_MEMORY;
    fflush(NULL);
    HANDLE job = make_job();
    const int started = job && start_program(line, job, &process);
    const DWORD reason = GetLastError();
    gsf_free(ctx, line);
    if (!started) {
        if (job) CloseHandle(job);
        return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: no new process: error %lu", (unsigned long)reason);
    }
    const double begin = gsfix_now();
    gsf_result result = GSF_OK;
    while (WaitForSingleObject(process.hProcess, 20) == WAIT_TIMEOUT && result == GSF_OK) {
        if (gsf_is_cancelled(ctx)) result = gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled");
        else if (gsfix_now() - begin > e->timeout)
            result = gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s took longer than %g s and was stopped", e->command,
                              e->timeout);
    }
    DWORD status = 1;
    if (result == GSF_OK && GetExitCodeProcess(process.hProcess, &status) && status != 0)
        result = gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s %s ended with status %lu", e->command, e->job,
                          (unsigned long)status);
    if (result != GSF_OK) TerminateJobObject(job, 1);
    CloseHandle(process.hThread);
    CloseHandle(process.hProcess);
    CloseHandle(job);
    return result;
}

static void end_group(exec_state* e) { (void)e; }

#else

static void watch(int life) { // runs in its own process; only async-signal-safe calls after the fork
    static const int ignored[] = {SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGPIPE};
    const long most = sysconf(_SC_OPEN_MAX);
    char byte;
    ssize_t n;
    for (size_t i = 0; i < sizeof ignored / sizeof *ignored; i++) signal(ignored[i], SIG_IGN);
    for (int fd = 0; fd < (most > 0 && most < 65536 ? most : 65536); fd++)
        if (fd != life) close(fd); // most importantly the lock on OUT
    while ((n = read(life, &byte, 1)) < 0 && errno == EINTR) {}
    kill(0, SIGKILL);
    _exit(0);
}

static gsf_result start_watcher(gsf_context* ctx, exec_state* e) {
    int ends[2];
    if (e->group) return GSF_OK;
    if (pipe(ends) != 0) return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: no pipe: %s", strerror(errno));
    fcntl(ends[0], F_SETFD, FD_CLOEXEC);
    fcntl(ends[1], F_SETFD, FD_CLOEXEC);
    const pid_t watcher = fork();
    if (watcher == 0) {
        setpgid(0, 0);
        watch(ends[0]);
    }
    close(ends[0]);
    if (watcher < 0) {
        close(ends[1]);
        return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: no new process: %s", strerror(errno));
    }
    setpgid(watcher, watcher); // in parent and child, to avoid a race
    e->group = watcher;
    e->life = ends[1];
    return GSF_OK;
}

static void end_group(exec_state* e) {
    if (!e->group) return;
    kill(-e->group, SIGKILL);
    while (waitpid(e->group, NULL, 0) < 0 && errno == EINTR) {}
    close(e->life);
    e->group = 0;
}

static void stop_program(exec_state* e, pid_t child) { // grants it a second to exit
    kill(-e->group, SIGTERM);
    for (int i = 0; i < 50; i++) {
        const struct timespec pause = {0, 20000000};
        if (waitpid(child, NULL, WNOHANG) == child) {
            end_group(e);
            return;
        }
        nanosleep(&pause, NULL);
    }
    kill(-e->group, SIGKILL);
    waitpid(child, NULL, 0);
    end_group(e);
}

static void become_program(const exec_state* e, const char* script, pid_t parent) { // in the child
    setpgid(0, e->group); // so that its children can be stopped with it
#ifdef __linux__
    prctl(PR_SET_PDEATHSIG, SIGKILL);
#endif
    if (getppid() != parent) _exit(127); // the parent has terminated meanwhile
    signal(SIGINT, SIG_DFL);
    signal(SIGTERM, SIG_DFL);
    signal(SIGXFSZ, SIG_DFL);
    dup2(2, 1); // stdout is reserved for --json
    execl("/bin/sh", "sh", "-c", script, "sh", e->job, (char*)NULL);
    _exit(127);
}

static gsf_result run_program(gsf_context* ctx, exec_state* e) {
    gsf_buffer script = {0};
    gsf_append_text(ctx, &script, "%s \"$@\"", e->command);
    if (script.failed) return GSF_ERROR_OUT_OF_MEMORY;
    const gsf_result watched = start_watcher(ctx, e);
    fflush(NULL);
    const pid_t parent = getpid(), child = watched == GSF_OK ? fork() : -1;
    if (child == 0) become_program(e, script.data, parent);
    gsf_destroy_buffer(ctx, &script);
    if (watched != GSF_OK) return watched;
    if (child < 0) return gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: no new process: %s", strerror(errno));
    setpgid(child, e->group); // in parent and child, to avoid a race
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
            stop_program(e, child);
            return cancelled ? gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled")
                             : gsf_fail(ctx, GSF_ERROR_RESTORER, "exec: %s took longer than %g s and was stopped",
                                        e->command, e->timeout);
        }
        const struct timespec pause = {0, 10000000};
        nanosleep(&pause, NULL);
    }
}

#endif

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
    end_group(e);
    gsf_free(ctx, e->command);
    gsf_free(ctx, e);
}

gsf_result gsfix_make_exec(gsfix_app* app, const char* command, double timeout, gsf_restorer* out) {
    gsf_context* ctx = &app->ctx;
    memset(out, 0, sizeof *out);
    exec_state* e = (exec_state*)gsf_alloc_zeroed(ctx, 1, sizeof *e);
    if (!e) return GSF_ERROR_OUT_OF_MEMORY;
    e->app = app;
    e->command = gsfix_copy_text(ctx, command, strlen(command));
    e->timeout = timeout;
    out->struct_size = sizeof *out;
    out->name = "exec";
    out->user = e;
    out->query_fn = exec_query;
    out->begin_fn = exec_begin;
    out->restore_fn = exec_restore;
    out->end_fn = exec_end;
    out->destroy_fn = exec_destroy;
    if (e->command) return GSF_OK;
    gsf_destroy_restorer(ctx, out);
    return GSF_ERROR_OUT_OF_MEMORY;
}
