// gsfix_process.c - programs that gsfix runs: they end with it, however it ends
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
#include <sys/stat.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <sys/prctl.h>
#endif
#endif

/* A program, what it starts, and a watcher form one process group. The watcher blocks on a pipe whose write end only gsfix
   holds: when gsfix terminates for any reason, even kill -9, the watcher reads end of file and kills the group. On Windows a
   job object, which ends with its last handle, takes the place of group and watcher. */

enum { FEED_BLOCK = 1 << 16 };

static gsf_result no_process(gsf_context* ctx, const gsfix_process* p, const char* reason) {
    return gsf_fail(ctx, p->code, "%s: no new process: %s", p->name, reason);
}

static void keep_words(gsfix_process* p, const char* text, size_t size) { // of the first line
    for (size_t i = 0; i < size && p->said_size + 1 < sizeof p->said && !p->said_all; i++) {
        if (text[i] != '\n' && text[i] != '\r') p->said[p->said_size++] = text[i];
        else p->said_all = p->said_size > 0;
    }
    p->said[p->said_size] = 0;
}

static gsf_result ended_badly(gsf_context* ctx, const gsfix_process* p, const char* how, long number) {
    return gsf_fail(ctx, p->code, "%s %s %ld%s%s", p->name, how, number, p->said_size ? ": " : "", p->said);
}

#ifdef _WIN32

static void close_handle(intptr_t* handle) {
    if (*handle) CloseHandle((HANDLE)*handle);
    *handle = 0;
}

static HANDLE make_job(void) { // all its processes end when the last handle is closed, at the latest when this process ends
    JOBOBJECT_EXTENDED_LIMIT_INFORMATION limits;
    HANDLE job = CreateJobObjectW(NULL, NULL);
    memset(&limits, 0, sizeof limits);
    limits.BasicLimitInformation.LimitFlags = JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE;
    if (job) SetInformationJobObject(job, JobObjectExtendedLimitInformation, &limits, sizeof limits);
    return job;
}

static wchar_t* command_line(gsf_context* ctx, const char* const* arguments) {
    gsf_buffer line = {0};
    for (; *arguments; arguments++) gsf_append_text(ctx, &line, "%s%s", line.size ? " " : "", *arguments);
    const int size = line.failed ? 0 : MultiByteToWideChar(CP_UTF8, 0, line.data, -1, NULL, 0);
    wchar_t* wide = size > 0 ? (wchar_t*)gsf_alloc(ctx, (size_t)size, sizeof *wide) : NULL;
    if (wide) MultiByteToWideChar(CP_UTF8, 0, line.data, -1, wide, size);
    gsf_destroy_buffer(ctx, &line);
    return wide;
}

static int make_pipe(int ours, HANDLE* theirs, intptr_t* mine) { // ours: 0: this process reads, 1: it writes
    SECURITY_ATTRIBUTES inherited = {sizeof inherited, NULL, TRUE};
    HANDLE ends[2];
    if (!CreatePipe(&ends[0], &ends[1], &inherited, 2 * FEED_BLOCK)) return 0;
    SetHandleInformation(ends[ours], HANDLE_FLAG_INHERIT, 0);
    *theirs = ends[!ours];
    *mine = (intptr_t)ends[ours];
    return 1;
}

gsf_result gsfix_start_process(gsf_context* ctx, gsfix_process* p, const char* const* arguments, int piped) {
    PROCESS_INFORMATION process;
    STARTUPINFOW start;
    HANDLE input = NULL, errors = NULL;
    wchar_t* line = command_line(ctx, arguments);
    if (!line) return GSF_ERROR_OUT_OF_MEMORY;
    fflush(NULL);
    p->said_size = 0, p->said_all = 0, p->said[0] = 0;
    memset(&start, 0, sizeof start);
    start.cb = sizeof start;
    int ok = !piped || (make_pipe(1, &input, &p->input) && make_pipe(0, &errors, &p->errors));
    if (ok && piped) {
        DWORD mode = PIPE_READMODE_BYTE | PIPE_NOWAIT; // so that a program that hangs can be given up
        SetNamedPipeHandleState((HANDLE)p->input, &mode, NULL, NULL);
    }
    start.dwFlags = STARTF_USESTDHANDLES;
    start.hStdInput = piped ? input : GetStdHandle(STD_INPUT_HANDLE);
    start.hStdError = piped ? errors : GetStdHandle(STD_ERROR_HANDLE);
    start.hStdOutput = start.hStdError; // stdout is reserved for --json
    if (ok) p->group = (intptr_t)make_job();
    ok = ok && p->group && CreateProcessW(NULL, line, NULL, NULL, TRUE, CREATE_SUSPENDED, NULL, NULL, &start, &process);
    const DWORD reason = GetLastError();
    if (input) CloseHandle(input);
    if (errors) CloseHandle(errors);
    gsf_free(ctx, line);
    if (!ok) {
        gsfix_end_process(p);
        return no_process(ctx, p, gsfix_pathf("error %lu", (unsigned long)reason).s);
    }
    AssignProcessToJobObject((HANDLE)p->group, process.hProcess); // before it can start others
    ResumeThread(process.hThread);
    CloseHandle(process.hThread);
    p->child = (intptr_t)process.hProcess;
    return GSF_OK;
}

static void hear(gsfix_process* p) {
    char text[512];
    DWORD there = 0, got = 0;
    while (p->errors && PeekNamedPipe((HANDLE)p->errors, NULL, 0, NULL, &there, NULL) && there &&
           ReadFile((HANDLE)p->errors, text, there < sizeof text ? there : (DWORD)sizeof text, &got, NULL) && got)
        keep_words(p, text, got);
}

static int has_ended(gsf_context* ctx, gsfix_process* p, int pause, gsf_result* result) { // pause: milliseconds
    DWORD status = 1;
    hear(p);
    if (WaitForSingleObject((HANDLE)p->child, (DWORD)pause) == WAIT_TIMEOUT) return 0;
    hear(p);
    *result = GSF_OK;
    if (!GetExitCodeProcess((HANDLE)p->child, &status) || status != 0)
        *result = ended_badly(ctx, p, "ended with status", (long)status);
    gsfix_end_process(p);
    return 1;
}

static ptrdiff_t feed_some(gsfix_process* p, const char* data, size_t size) { // -1: nobody reads
    DWORD taken = 0;
    if (!WriteFile((HANDLE)p->input, data, (DWORD)(size < FEED_BLOCK ? size : (size_t)FEED_BLOCK), &taken, NULL)) return -1;
    return (ptrdiff_t)taken;
}

static void close_input(gsfix_process* p) { close_handle(&p->input); }

void gsfix_end_process(gsfix_process* p) {
    if (p->group) TerminateJobObject((HANDLE)p->group, 1);
    close_handle(&p->input);
    close_handle(&p->errors);
    close_handle(&p->child);
    close_handle(&p->group);
}

static void stop_process(gsfix_process* p) { gsfix_end_process(p); }

int gsfix_find_program(const char* name, gsfix_path* out) { // not in the current folder, where CreateProcess would look, too
    const wchar_t* wide = _wgetenv(L"PATH");
    char* list = NULL;
    const int size = wide ? WideCharToMultiByte(CP_UTF8, 0, wide, -1, NULL, 0, NULL, NULL) : 0;
    int found = 0;
    if (size > 0) list = (char*)malloc((size_t)size);
    if (list) WideCharToMultiByte(CP_UTF8, 0, wide, -1, list, size, NULL, NULL);
    for (const char* p = list; p && *p && !found; p += strcspn(p, ";"), p += *p == ';') {
        const int n = (int)strcspn(p, ";");
        *out = gsfix_pathf("%.*s/%s.exe", n, p, name);
        found = n > 1 && (p[1] == ':' || p[0] == '\\') && gsfix_exists(out->s) && !gsfix_is_folder(out->s);
    }
    free(list);
    return found;
}

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

static void close_end(intptr_t* file) { // 0: not open; the standard streams, which come first, are never among these
    if (*file) close((int)*file);
    *file = 0;
}

static int make_pipe(int ends[2]) { // of descriptors above the standard ones, not inherited
    if (pipe(ends) != 0) return 0;
    for (int i = 0; i < 2; i++) {
        const int high = fcntl(ends[i], F_DUPFD_CLOEXEC, 3);
        close(ends[i]);
        ends[i] = high;
    }
    if (ends[0] >= 0 && ends[1] >= 0) return 1;
    for (int i = 0; i < 2; i++) {
        if (ends[i] >= 0) close(ends[i]);
        ends[i] = -1;
    }
    return 0;
}

static int start_watcher(gsfix_process* p) {
    int ends[2];
    if (p->group) return 1;
    if (!make_pipe(ends)) return 0;
    const pid_t watcher = fork();
    if (watcher == 0) {
        setpgid(0, 0);
        watch(ends[0]);
    }
    const int reason = errno;
    close(ends[0]);
    if (watcher < 0) {
        close(ends[1]);
        errno = reason;
        return 0;
    }
    setpgid(watcher, watcher); // in parent and child, to avoid a race
    p->group = watcher;
    p->life = ends[1];
    return 1;
}

static void become_program(const gsfix_process* p, const char* const* arguments, const int* streams, pid_t parent) {
    setpgid(0, (pid_t)p->group); // so that its children can be stopped with it
#ifdef __linux__
    prctl(PR_SET_PDEATHSIG, SIGKILL);
#endif
    if (getppid() != parent) _exit(127); // the parent has terminated meanwhile
    signal(SIGINT, SIG_DFL);
    signal(SIGTERM, SIG_DFL);
#ifdef SIGXFSZ
    signal(SIGXFSZ, SIG_DFL);
#endif
    if (streams[0] >= 0) dup2(streams[0], 0);
    if (streams[1] >= 0) dup2(streams[1], 2);
    dup2(2, 1); // stdout is reserved for --json
    execv(arguments[0], (char* const*)(uintptr_t)(const void*)arguments);
    _exit(127);
}

gsf_result gsfix_start_process(gsf_context* ctx, gsfix_process* p, const char* const* arguments, int piped) {
    int input[2] = {-1, -1}, errors[2] = {-1, -1};
    p->said_size = 0, p->said_all = 0, p->said[0] = 0;
    int ok = start_watcher(p) && (!piped || (make_pipe(input) && make_pipe(errors)));
    fflush(NULL);
    const int streams[2] = {input[0], errors[1]};
    const pid_t parent = getpid(), child = ok ? fork() : -1;
    if (child == 0) become_program(p, arguments, streams, parent);
    const int reason = errno;
    for (int i = 0; i < 2; i++)
        if (streams[i] >= 0) close(streams[i]);
    p->input = input[1] > 0 ? input[1] : 0;
    p->errors = errors[0] > 0 ? errors[0] : 0;
    if (child < 0) {
        close_end(&p->input);
        close_end(&p->errors);
        return no_process(ctx, p, strerror(reason));
    }
    setpgid(child, (pid_t)p->group); // in parent and child, to avoid a race
    p->child = child;
    if (p->input) fcntl((int)p->input, F_SETFL, O_NONBLOCK); // so that a program that hangs can be given up
    if (p->errors) fcntl((int)p->errors, F_SETFL, O_NONBLOCK);
    return GSF_OK;
}

static void hear(gsfix_process* p) {
    char text[512];
    ssize_t n = 0;
    while (p->errors && (n = read((int)p->errors, text, sizeof text)) > 0) keep_words(p, text, (size_t)n);
}

static int has_ended(gsf_context* ctx, gsfix_process* p, int pause, gsf_result* result) { // pause: milliseconds
    int status = 0;
    hear(p);
    const pid_t ended = waitpid((pid_t)p->child, &status, WNOHANG);
    if (ended == 0 || (ended < 0 && errno == EINTR)) {
        const struct timespec time = {0, pause * 1000000L};
        nanosleep(&time, NULL);
        return 0;
    }
    hear(p);
    *result = GSF_OK;
    if (ended < 0) *result = gsf_fail(ctx, p->code, "%s: waitpid: %s", p->name, strerror(errno));
    else if (WIFSIGNALED(status)) *result = ended_badly(ctx, p, "was ended by signal", WTERMSIG(status));
    else if (WEXITSTATUS(status) != 0) *result = ended_badly(ctx, p, "ended with status", WEXITSTATUS(status));
    p->child = 0;
    close_end(&p->input);
    close_end(&p->errors);
    return 1;
}

static ptrdiff_t feed_some(gsfix_process* p, const char* data, size_t size) { // -1: nobody reads
    void (*const before)(int) = signal(SIGPIPE, SIG_IGN);
    const ssize_t n = write((int)p->input, data, size < FEED_BLOCK ? size : (size_t)FEED_BLOCK);
    const int reason = errno;
    signal(SIGPIPE, before);
    return n >= 0 ? (ptrdiff_t)n : reason == EAGAIN || reason == EINTR ? 0 : -1;
}

static void close_input(gsfix_process* p) { close_end(&p->input); }

void gsfix_end_process(gsfix_process* p) {
    if (!p->group) return;
    kill(-(pid_t)p->group, SIGKILL);
    if (p->child) waitpid((pid_t)p->child, NULL, 0);
    while (waitpid((pid_t)p->group, NULL, 0) < 0 && errno == EINTR) {}
    close_end(&p->life);
    close_end(&p->input);
    close_end(&p->errors);
    p->group = p->child = 0;
}

static void stop_process(gsfix_process* p) { // grants it a second to exit
    kill(-(pid_t)p->group, SIGTERM);
    for (int i = 0; i < 50 && p->child; i++) {
        const struct timespec pause = {0, 20000000};
        if (waitpid((pid_t)p->child, NULL, WNOHANG) == (pid_t)p->child) p->child = 0;
        else nanosleep(&pause, NULL);
    }
    gsfix_end_process(p);
}

int gsfix_find_program(const char* name, gsfix_path* out) {
    for (const char* p = getenv("PATH"); p && *p; p += strcspn(p, ":"), p += *p == ':') {
        struct stat s;
        *out = gsfix_pathf("%.*s/%s", (int)strcspn(p, ":"), p, name);
        if (*p == '/' && stat(out->s, &s) == 0 && S_ISREG(s.st_mode) && access(out->s, X_OK) == 0) return 1;
    }
    return 0;
}

#endif

static gsf_result give_up(gsf_context* ctx, gsfix_process* p, const char* why, double seconds) {
    stop_process(p);
    if (gsf_is_cancelled(ctx)) return gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled");
    return gsf_fail(ctx, p->code, "%s %s %g s and was stopped", p->name, why, seconds);
}

gsf_result gsfix_wait_process(gsf_context* ctx, gsfix_process* p, double timeout) {
    const double begin = gsfix_now();
    gsf_result result = GSF_OK;
    close_input(p);
    while (!has_ended(ctx, p, 10, &result))
        if (gsf_is_cancelled(ctx) || gsfix_now() - begin > timeout) return give_up(ctx, p, "took longer than", timeout);
    return result;
}

gsf_result gsfix_feed_process(gsf_context* ctx, gsfix_process* p, const void* data, size_t size, double timeout) {
    double last = gsfix_now();
    for (const char* at = (const char*)data; size;) {
        const ptrdiff_t taken = feed_some(p, at, size);
        gsf_result result = GSF_OK;
        hear(p);
        if (taken > 0) {
            at += taken;
            size -= (size_t)taken;
            last = gsfix_now();
        } else if (gsf_is_cancelled(ctx) || gsfix_now() - last > timeout) {
            return give_up(ctx, p, "took nothing for", timeout);
        } else if (taken < 0 || has_ended(ctx, p, 2, &result)) {
            if (taken < 0) result = gsfix_wait_process(ctx, p, timeout);
            return result != GSF_OK ? result : gsf_fail(ctx, p->code, "%s ended before it had taken everything", p->name);
        }
    }
    return GSF_OK;
}
