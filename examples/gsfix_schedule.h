// gsfix_schedule.h - hands tasks out to workers of which any may be lost: gsfix_mpi's decisions, without messages or clocks
// SPDX-License-Identifier: MIT
#ifndef GSFIX_SCHEDULE_H
#define GSFIX_SCHEDULE_H

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* A task is handed out once it is ready: in order, and only after the one that it needs. A worker has one task at a time. If it
   is lost, its task is ready again, unless it has been tried SCHEDULE_TRIES times. A worker that was thought lost may still
   report: the first report of success counts. Each call takes constant time. */
enum { SCHEDULE_TRIES = 4 };
#define SCHEDULE_NONE SIZE_MAX
typedef enum schedule_state { SCHEDULE_WAITS, SCHEDULE_RUNS, SCHEDULE_DONE, SCHEDULE_FAILED } schedule_state;

typedef struct schedule_task {
    size_t child, sibling;      // first task that needs this one; next one that needs the same
    size_t next;                // in the queue of ready tasks
    schedule_state state;
    int tries;
} schedule_task;

typedef struct schedule_worker { size_t task; double heard; int lost; } schedule_worker; // heard: time of its last message

typedef struct schedule {
    schedule_task* tasks;
    schedule_worker* workers;
    size_t task_count, worker_count, first, last; // first, last: of the queue
    size_t ended, failed, alive;                  // alive: workers that are not lost
} schedule;

static void schedule_queue(schedule* s, size_t task) {
    s->tasks[task].next = SCHEDULE_NONE;
    s->tasks[task].state = SCHEDULE_WAITS;
    if (s->first == SCHEDULE_NONE) s->first = task;
    else s->tasks[s->last].next = task;
    s->last = task;
}

// needs: per task an earlier one or itself; NULL: none needs another. Returns 0 if there is no memory.
static int schedule_begin(schedule* s, size_t task_count, const size_t* needs, size_t worker_count, double now) {
    memset(s, 0, sizeof *s);
    s->tasks = (schedule_task*)calloc(task_count + 1, sizeof *s->tasks);
    s->workers = (schedule_worker*)calloc(worker_count + 1, sizeof *s->workers);
    s->task_count = task_count;
    s->alive = s->worker_count = worker_count;
    s->first = s->last = SCHEDULE_NONE;
    if (!s->tasks || !s->workers) return 0;
    for (size_t i = 0; i < task_count; i++) s->tasks[i].child = s->tasks[i].sibling = SCHEDULE_NONE;
    for (size_t i = task_count; i-- > 0;) {
        if (!needs || needs[i] == i) continue;
        s->tasks[i].sibling = s->tasks[needs[i]].child;
        s->tasks[needs[i]].child = i;
    }
    for (size_t i = 0; i < task_count; i++)
        if (!needs || needs[i] == i) schedule_queue(s, i);
    for (size_t i = 0; i < worker_count; i++) {
        s->workers[i].task = SCHEDULE_NONE;
        s->workers[i].heard = now;
    }
    return 1;
}

static void schedule_end(schedule* s) {
    free(s->tasks);
    free(s->workers);
    memset(s, 0, sizeof *s);
}

static int schedule_is_over(const schedule* s) { return s->ended == s->task_count; }

static void schedule_hear(schedule* s, size_t worker, double now) {
    s->workers[worker].heard = now;
    s->alive += (size_t)s->workers[worker].lost;
    s->workers[worker].lost = 0;
}

// The task that the worker gets; SCHEDULE_NONE: none is ready.
static size_t schedule_next(schedule* s, size_t worker) {
    while (s->first != SCHEDULE_NONE) {
        const size_t task = s->first;
        s->first = s->tasks[task].next;
        if (s->tasks[task].state != SCHEDULE_WAITS) continue; // done meanwhile by a worker that was thought lost
        s->tasks[task].state = SCHEDULE_RUNS;
        s->tasks[task].tries++;
        s->workers[worker].task = task;
        return task;
    }
    return SCHEDULE_NONE;
}

// Ends a task for good; with a failure also those that need it. ended_fn is called for each.
typedef void (*schedule_ended_fn)(void* user, size_t task, int ok);
static void schedule_settle(schedule* s, size_t task, int ok, schedule_ended_fn ended_fn, void* user) {
    schedule_task* t = &s->tasks[task];
    if (t->state == SCHEDULE_DONE || t->state == SCHEDULE_FAILED) return;
    t->state = ok ? SCHEDULE_DONE : SCHEDULE_FAILED;
    s->ended++;
    s->failed += !ok;
    if (ended_fn) ended_fn(user, task, ok);
    for (size_t child = t->child; child != SCHEDULE_NONE; child = s->tasks[child].sibling) {
        if (ok) schedule_queue(s, child);
        else schedule_settle(s, child, 0, ended_fn, user);
    }
}

// A worker reports the end of its task.
static void schedule_report(schedule* s, size_t worker, size_t task, int ok, schedule_ended_fn ended_fn, void* user) {
    const int current = s->workers[worker].task == task;
    if (current) s->workers[worker].task = SCHEDULE_NONE;
    if (ok || current) schedule_settle(s, task, ok, ended_fn, user); // else it was given to another one
}

// A worker's task has ended without a result of its own: its process was killed.
static void schedule_retry(schedule* s, size_t worker, schedule_ended_fn ended_fn, void* user) {
    const size_t task = s->workers[worker].task;
    s->workers[worker].task = SCHEDULE_NONE;
    if (task == SCHEDULE_NONE || s->tasks[task].state != SCHEDULE_RUNS) return;
    if (s->tasks[task].tries < SCHEDULE_TRIES) schedule_queue(s, task);
    else schedule_settle(s, task, 0, ended_fn, user);
}

static void schedule_lose(schedule* s, size_t worker, schedule_ended_fn ended_fn, void* user) {
    s->alive -= (size_t)!s->workers[worker].lost;
    s->workers[worker].lost = 1;
    schedule_retry(s, worker, ended_fn, user);
}

#endif
