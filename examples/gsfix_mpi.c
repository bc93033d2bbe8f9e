// gsfix_mpi.c - gsfix dataset and gsfix evaluate on many machines that share a file system:
//   mpirun -np N gsfix_mpi dataset|evaluate SCENE... --out DIR [options as for gsfix]
// SPDX-License-Identifier: MIT
#include "gsfix.h"
#include "gsfix_schedule.h"

#include <errno.h>
#include <fcntl.h>
#include <mpi.h>
#include <signal.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <sys/prctl.h>
#endif

/* Rank 0 lists the tasks, hands them out one by one, and merges their folders in the end, as `gsfix` alone does; the other
   ranks work. A rank does not do its task itself: it starts `gsfix_mpi ... --task NAME` as a process of its own, which does not
   use MPI, and meanwhile reports every second that it lives. So
   - a task whose process crashes or is killed (by the kernel for lack of memory, say) is handed out again and continued from
     its checkpoint, at most SCHEDULE_TRIES times;
   - a rank that is killed takes its process along; rank 0 misses it after LOST_AFTER seconds (on its own machine within one)
     and hands its task out again. mpirun must be told to carry on: --enable-recovery. Without workers rank 0 does the tasks
     itself. Workers that miss rank 0 in the same way exit;
   - a rank that was only slow does no harm: a task's folder is locked by the process at work in it, and the other one waits.
   Results do not depend on who does a task, so that the output is that of one process, byte for byte. If rank 0 or mpirun
   dies, the same command with --resume goes on. Where a rank was lost, all others leave without MPI_Finalize, which may wait
   for the lost one for ever; else they enter it together, when rank 0 has merged the folders. */
enum { TAG_TO_WORKER = 1, TAG_TO_CHIEF = 2, TEXT_MOST = 400, BUSY_MOST = 600 };
enum { ORDER_STOP = -1, ORDER_NONE = -2, ORDER_LEAVE = -3, NEWS_READY = 0, NEWS_ALIVE, NEWS_DONE, NEWS_FAILED, NEWS_KILLED };
enum { START_MOST = 300, END_MOST = 10, MERGE_MOST = 3600 }; // seconds until all have started, for MPI to end, for merging
static const double LOST_AFTER = 60.0, ALIVE_EVERY = 1.0, LOOK_EVERY = 0.5, ORDER_EVERY = 10.0;

typedef struct news { // from a worker
    int32_t kind, pid;
    int64_t task;
    double seconds;
    char host[64], text[TEXT_MOST];
} news;

typedef struct order { // to a worker
    int64_t task;       // or ORDER_STOP: no more tasks; ORDER_LEAVE: all is merged; ORDER_NONE: says only that rank 0 lives
    int32_t again, pid; // again: a try after the first one
    int32_t lost;       // of ORDER_LEAVE: a rank was lost
    char name[256], host[64];
} order;

// All messages are buffered sends (MPI_Bsend), since an ordinary one to a rank that has just died may never return.
typedef struct mpi_job {
    int argc;
    char** argv;
    int quiet, resumes; // --json, --resume or --restart is on the command line
} mpi_job;

static void pause_for(double seconds) {
    const struct timespec t = {(time_t)seconds, (long)(1e9 * (seconds - (double)(time_t)seconds))};
    nanosleep(&t, NULL);
}

// ---- a task's process ----------------------------------------------------------------

typedef struct task_process {
    pid_t pid;
    int errors;  // read end of its stderr
    char last[TEXT_MOST];
    size_t used; // of `last`, which is complete after a line break
    int broken;  // `last` is complete: the next byte begins a new line
    double begin;
} task_process;

static int start_process(const mpi_job* job, const char* name, int again, task_process* p) {
    int ends[2];
    char** argv = (char**)calloc((size_t)job->argc + 4, sizeof *argv);
    const pid_t parent = getpid();
    memset(p, 0, sizeof *p);
    if (!argv || pipe(ends) != 0) return free(argv), 0;
    for (int i = 0; i < job->argc; i++) argv[i] = job->argv[i];
    argv[job->argc] = (char*)(uintptr_t)"--task";
    argv[job->argc + 1] = (char*)(uintptr_t)name;
    if (again && !job->resumes) argv[job->argc + 2] = (char*)(uintptr_t)"--resume";
    p->begin = gsfix_now();
    p->pid = fork();
    if (p->pid == 0) {
        const int nothing = open("/dev/null", O_WRONLY);
#ifdef __linux__
        prctl(PR_SET_PDEATHSIG, SIGKILL);
#endif
        if (getppid() != parent) _exit(1);
        dup2(ends[1], 2);
        if (job->quiet && nothing >= 0) dup2(nothing, 1);
        for (int fd = 3; fd < 256; fd++) close(fd); // MPI's connections among them
        execv("/proc/self/exe", argv);
        execvp(argv[0], argv);
        _exit(127);
    }
    close(ends[1]);
    free(argv);
    p->errors = ends[0];
    fcntl(p->errors, F_SETFL, O_NONBLOCK);
    fcntl(p->errors, F_SETFD, FD_CLOEXEC);
    if (p->pid < 0) close(p->errors);
    return p->pid > 0;
}

static void read_errors(task_process* p) { // keeps the last line
    char bytes[1024];
    for (ssize_t n; (n = read(p->errors, bytes, sizeof bytes)) > 0;)
        for (ssize_t i = 0; i < n; i++) {
            if (p->broken) p->used = 0, p->broken = 0;
            if (bytes[i] == '\n') p->broken = 1;
            else if (p->used + 1 < sizeof p->last) p->last[p->used++] = bytes[i];
            p->last[p->used] = 0;
        }
}

// Has the process ended? Then *kind is NEWS_DONE, NEWS_FAILED with its last line, or NEWS_KILLED.
static int has_ended(task_process* p, int32_t* kind) {
    int status = 0;
    read_errors(p);
    const pid_t pid = waitpid(p->pid, &status, WNOHANG);
    if (pid == 0 || (pid < 0 && errno == EINTR)) return 0;
    read_errors(p);
    close(p->errors);
    *kind = pid < 0 || WIFSIGNALED(status) ? NEWS_KILLED : WEXITSTATUS(status) == 0 ? NEWS_DONE : NEWS_FAILED;
    if (pid > 0 && WIFSIGNALED(status)) snprintf(p->last, sizeof p->last, "killed by signal %d", WTERMSIG(status));
    const char* text = strncmp(p->last, "gsfix ", 6) == 0 ? strstr(p->last, ": ") : NULL;
    if (text) memmove(p->last, text + 2, strlen(text + 2) + 1);
    return 1;
}

static int is_busy(const task_process* p) { return strstr(p->last, "another gsfix is at work there") != NULL; }

// Does a process with this number run on this machine, or on another one, of which that is not known?
static int may_live(const char* host, int32_t pid) {
    char mine[64] = "";
    gethostname(mine, sizeof mine - 1);
    return !pid || strcmp(host, mine) != 0 || kill(pid, 0) == 0 || errno != ESRCH;
}

// ---- workers -------------------------------------------------------------------------

typedef struct worker {
    const mpi_job* job;
    news n;
    order last;           // what rank 0 said last
    double said, heard;   // when
} worker;

static void send_news(worker* w, int32_t kind) {
    w->n.kind = kind;
    MPI_Bsend(&w->n, (int)sizeof w->n, MPI_BYTE, 0, TAG_TO_CHIEF, MPI_COMM_WORLD);
    w->said = gsfix_now();
}

// Takes a message of rank 0, if there is one. Exits if there is no rank 0 any more, or none has come for `patience` seconds.
static int listen_to_chief(worker* w, double patience) {
    int there = 0;
    MPI_Iprobe(0, TAG_TO_WORKER, MPI_COMM_WORLD, &there, MPI_STATUS_IGNORE);
    if (there) {
        MPI_Recv(&w->last, (int)sizeof w->last, MPI_BYTE, 0, TAG_TO_WORKER, MPI_COMM_WORLD, MPI_STATUS_IGNORE);
        w->heard = gsfix_now();
    } else if (gsfix_now() - w->said > ALIVE_EVERY) {
        if (!may_live(w->last.host, w->last.pid) || gsfix_now() - w->heard > patience) _exit(1); // takes the task along
        w->said = gsfix_now();
        return 0;
    }
    return 1;
}

static void keep_in_touch(worker* w, int32_t kind) { // also says `kind` once a second
    if (!listen_to_chief(w, 2.0 * LOST_AFTER)) send_news(w, kind);
}

static int is_over(const worker* w) { return w->last.task == ORDER_STOP || w->last.task == ORDER_LEAVE; }

static void do_order(worker* w) {
    const order o = w->last;
    int32_t kind = NEWS_KILLED;
    const double begin = gsfix_now();
    task_process p;
    w->n.task = o.task;
    w->n.text[0] = 0;
    for (int running = start_process(w->job, o.name, o.again, &p); running;) {
        keep_in_touch(w, NEWS_ALIVE);
        if (is_over(w)) kill(p.pid, SIGINT); // leaves a checkpoint
        if (!has_ended(&p, &kind)) {
            pause_for(0.001);
        } else if (kind == NEWS_FAILED && is_busy(&p) && gsfix_now() - begin < BUSY_MOST && !is_over(w)) {
            pause_for(0.5); // the process of a rank that is thought lost; what it does counts, too
            running = start_process(w->job, o.name, 1, &p);
        } else {
            running = 0;
        }
    }
    w->n.seconds = gsfix_now() - begin;
    snprintf(w->n.text, sizeof w->n.text, "%s", p.last);
    send_news(w, kind);
}

static int work(const mpi_job* job) { // was a rank lost?
    static worker w; // zeroed
    w.job = job;
    w.heard = gsfix_now();
    w.n.pid = (int32_t)getpid();
    gethostname(w.n.host, sizeof w.n.host - 1);
    w.n.task = w.last.task = ORDER_NONE;
    for (send_news(&w, NEWS_READY); !is_over(&w);) {
        keep_in_touch(&w, NEWS_READY);
        if (w.last.task >= 0) {
            do_order(&w);
            w.n.task = ORDER_NONE;
            if (w.last.task >= 0) w.last.task = ORDER_NONE; // done, and nothing came meanwhile
        } else {
            pause_for(0.001);
        }
    }
    while (w.last.task != ORDER_LEAVE) { // rank 0 merges, and is silent meanwhile
        (void)listen_to_chief(&w, MERGE_MOST);
        pause_for(0.001);
    }
    return w.last.lost;
}

// ---- rank 0 --------------------------------------------------------------------------

typedef struct chief {
    gsfix_app* app;
    const mpi_job* job;
    gsfix_tally* tally;
    schedule s;
    news* known;       // per worker: its last message
    uint8_t* idle;     // per worker: waits for an order
    char why[TEXT_MOST];           // text of the report at hand
    double seconds;                // of the report at hand
    int by;
} chief;

static uint8_t* lost_ranks; // per rank; no messages to these
static int workers_stopped;

static void on_end(void* user, size_t task, int ok) {
    chief* c = (chief*)user;
    gsfix_app* app = c->app;
    gsf_context* ctx = &app->ctx;
    const gsfix_tasks* t = c->tally->tasks;
    const size_t need = t->needs ? t->needs[task] : task;
    const int skipped = need != task && !c->tally->done[need];
    const gsfix_path why = skipped ? gsfix_pathf("needs %s, which is not done", t->names[need]) : gsfix_pathf("%s", c->why);
    gsfix_json_begin(ctx, &app->json, NULL, '{');
    gsfix_json_text(ctx, &app->json, "name", t->names[task]);
    gsfix_json_number(ctx, &app->json, "rank", c->by);
    if (!ok) gsfix_json_text(ctx, &app->json, "error", why.s);
    gsfix_json_end(ctx, &app->json, '}');
    gsfix_note_task(app, c->tally, task, ok ? GSF_OK : GSF_ERROR_IO, why.s);
    if (ok) gsfix_note(app, "%zu of %zu: %s, rank %d, %.1f s", c->s.ended, t->count, t->names[task], c->by, c->seconds);
}

static void send_order(order* o, int rank) {
    o->pid = (int32_t)getpid();
    gethostname(o->host, sizeof o->host - 1);
    MPI_Bsend(o, (int)sizeof *o, MPI_BYTE, rank, TAG_TO_WORKER, MPI_COMM_WORLD);
}

static void give_order(chief* c, size_t worker_index, size_t task) {
    order o;
    memset(&o, 0, sizeof o);
    o.task = (int64_t)task;
    o.again = c->s.tasks[task].tries > 1;
    snprintf(o.name, sizeof o.name, "%s", c->tally->tasks->names[task]);
    c->idle[worker_index] = 0;
    send_order(&o, (int)worker_index + 1);
}

static void send_to_all(int ranks, int64_t task) {
    order o;
    memset(&o, 0, sizeof o);
    o.task = task;
    for (int i = 1; i < ranks; i++) o.lost |= lost_ranks[i];
    for (int i = 1; i < ranks; i++)
        if (!lost_ranks[i]) send_order(&o, i);
}

static void hear(chief* c, size_t from, const news* n) {
    const int known = n->task >= 0 && (size_t)n->task < c->s.task_count;
    schedule_hear(&c->s, from, gsfix_now());
    lost_ranks[from + 1] = 0;
    c->known[from] = *n;
    c->by = (int)from + 1;
    c->seconds = n->seconds;
    snprintf(c->why, sizeof c->why, "%.*s", TEXT_MOST - 1, n->text);
    if (n->kind == NEWS_ALIVE) return;
    if (known && n->kind == NEWS_KILLED) {
        gsfix_note(c->app, "%s: its process on rank %d: %s", c->tally->tasks->names[n->task], c->by,
                   n->text[0] ? n->text : "could not be started");
        schedule_retry(&c->s, from, on_end, c);
    } else if (known) {
        schedule_report(&c->s, from, (size_t)n->task, n->kind == NEWS_DONE, on_end, c);
    }
    c->idle[from] = c->s.workers[from].task == SCHEDULE_NONE; // else an order is on its way
}

static int receive(chief* c) { // a message, if there is one
    news n;
    MPI_Status status;
    int there = 0;
    MPI_Iprobe(MPI_ANY_SOURCE, TAG_TO_CHIEF, MPI_COMM_WORLD, &there, &status);
    if (!there) return 0;
    MPI_Recv(&n, (int)sizeof n, MPI_BYTE, status.MPI_SOURCE, TAG_TO_CHIEF, MPI_COMM_WORLD, MPI_STATUS_IGNORE);
    hear(c, (size_t)status.MPI_SOURCE - 1, &n);
    return 1;
}

static void look_for_lost(chief* c) {
    const double now = gsfix_now();
    for (size_t w = 0; w < c->s.worker_count; w++) {
        if (c->s.workers[w].lost) continue;
        if (may_live(c->known[w].host, c->known[w].pid) && now - c->s.workers[w].heard < LOST_AFTER) continue;
        const size_t task = c->s.workers[w].task;
        gsfix_note(c->app, "rank %d is lost%s%s", (int)w + 1, task == SCHEDULE_NONE ? "" : ", and hands back ",
                   task == SCHEDULE_NONE ? "" : c->tally->tasks->names[task]);
        snprintf(c->why, sizeof c->why, "the rank at work on it was lost %d times", SCHEDULE_TRIES);
        c->idle[w] = 0;
        c->by = (int)w + 1;
        schedule_lose(&c->s, w, on_end, c);
        lost_ranks[w + 1] = 1;
    }
}

static void work_alone(chief* c) { // rank 0, in the place of worker_count, which no rank has
    const size_t me = c->s.worker_count, task = schedule_next(&c->s, me);
    task_process p;
    int32_t kind = NEWS_KILLED;
    if (task == SCHEDULE_NONE) return;
    if (start_process(c->job, c->tally->tasks->names[task], c->s.tasks[task].tries > 1, &p))
        while (!has_ended(&p, &kind)) {
            if (gsf_is_cancelled(&c->app->ctx)) kill(p.pid, SIGINT);
            pause_for(0.002);
        }
    c->by = 0;
    c->seconds = gsfix_now() - p.begin;
    snprintf(c->why, sizeof c->why, "%s", p.last);
    if (kind == NEWS_FAILED && is_busy(&p)) pause_for(0.5), kind = NEWS_KILLED;
    if (kind == NEWS_KILLED) schedule_retry(&c->s, me, on_end, c);
    else schedule_report(&c->s, me, task, kind == NEWS_DONE, on_end, c);
}

static gsf_result lead(gsfix_app* app, void* user, gsfix_tally* tally) {
    gsf_context* ctx = &app->ctx;
    chief c;
    int ranks;
    double looked = gsfix_now(), ordered = looked;
    gsf_result result = GSF_OK;
    memset(&c, 0, sizeof c);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);
    c.app = app;
    c.job = (const mpi_job*)user;
    c.tally = tally;
    c.known = (news*)gsf_alloc_zeroed(ctx, (size_t)ranks, sizeof *c.known);
    c.idle = (uint8_t*)gsf_alloc_zeroed(ctx, (size_t)ranks, 1);
    if (!schedule_begin(&c.s, tally->tasks->count, tally->tasks->needs, (size_t)ranks - 1, looked) || !c.known || !c.idle)
        result = GSF_ERROR_OUT_OF_MEMORY;
    while (result == GSF_OK && !schedule_is_over(&c.s)) {
        const int heard = receive(&c);
        for (size_t w = 0; w < c.s.worker_count; w++) {
            if (!c.idle[w] || c.s.workers[w].lost) continue;
            const size_t task = schedule_next(&c.s, w);
            if (task == SCHEDULE_NONE) break;
            give_order(&c, w, task);
        }
        if (gsfix_now() - looked > LOOK_EVERY) {
            look_for_lost(&c);
            looked = gsfix_now();
        }
        if (looked - ordered > ORDER_EVERY) {
            send_to_all(ranks, ORDER_NONE);
            ordered = looked;
        }
        if (!c.s.alive) work_alone(&c);
        else if (!heard) pause_for(0.0005);
        if (gsf_is_cancelled(ctx)) result = gsf_fail(ctx, GSF_ERROR_CANCELLED, "stopped; --resume goes on");
    }
    send_to_all(ranks, ORDER_STOP);
    workers_stopped = 1;
    gsf_free(ctx, c.known);
    gsf_free(ctx, c.idle);
    schedule_end(&c.s);
    return result;
}

// ---- main ----------------------------------------------------------------------------

static volatile sig_atomic_t exit_code = 1, is_ending;

static void on_alarm(int number) { // MPI waits for ranks that are lost
    static const char text[] = "gsfix_mpi: not all ranks have started\n";
    (void)number;
    if (!is_ending) (void)!write(2, text, sizeof text - 1);
    _exit(exit_code);
}

int main(int argc, char** argv) {
    mpi_job job = {argc, argv, 0, 0};
    const gsfix_crew crew = {lead, &job};
    int rank, ranks, code = 0, lost = 0;
    for (int i = 1; i < argc; i++) {
        if (strcmp(argv[i], "--task") == 0 || strncmp(argv[i], "--task=", 7) == 0) return gsfix_start(argc, argv, NULL);
        job.quiet |= strcmp(argv[i], "--json") == 0;
        job.resumes |= strcmp(argv[i], "--resume") == 0 || strcmp(argv[i], "--restart") == 0;
    }
    signal(SIGALRM, on_alarm);
    alarm(START_MOST);
    MPI_Init(&argc, &argv);
    alarm(0);
    MPI_Comm_set_errhandler(MPI_COMM_WORLD, MPI_ERRORS_RETURN);
    MPI_Comm_rank(MPI_COMM_WORLD, &rank);
    MPI_Comm_size(MPI_COMM_WORLD, &ranks);
    const int buffer_size = (8 * ranks + 256) * (int)(sizeof(news) + MPI_BSEND_OVERHEAD);
    void* buffer = malloc((size_t)buffer_size);
    lost_ranks = (uint8_t*)calloc((size_t)ranks, 1);
    if (!lost_ranks || !buffer) MPI_Abort(MPI_COMM_WORLD, 1);
    MPI_Buffer_attach(buffer, buffer_size);
    if (rank > 0) lost = work(&job);
    else code = gsfix_start(argc, argv, &crew);
    if (rank == 0 && !workers_stopped) send_to_all(ranks, ORDER_STOP); // a mistake in the command line
    if (rank == 0) send_to_all(ranks, ORDER_LEAVE);
    for (int i = 0; i < ranks; i++) lost |= lost_ranks[i];
    fflush(NULL);
    if (lost) {
        for (int i = 0, there; rank == 0 && i < 200; i++) { // buffered messages leave while MPI is called
            MPI_Iprobe(MPI_ANY_SOURCE, TAG_TO_CHIEF, MPI_COMM_WORLD, &there, MPI_STATUS_IGNORE);
            pause_for(0.001);
        }
        _exit(code);
    }
    exit_code = code;
    is_ending = 1;
    alarm(END_MOST); // a rank may be killed even now, and then MPI would wait for ever
    MPI_Finalize();
    free(lost_ranks);
    free(buffer);
    return code;
}
