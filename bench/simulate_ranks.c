// simulate_ranks.c - gsfix_mpi's schedule with simulated ranks: how much of the machines' time is work
//   simulate_ranks [--ranks N] [--tasks N] [--seconds S] [--start S] [--message S] [--lost-per-hour X] [--seed S]
// SPDX-License-Identifier: MIT
#include "../examples/gsfix_schedule.h"

#include "gsfixer.h"

#include <math.h>
#include <stdio.h>
#include <time.h>

/* Decisions are those of examples/gsfix_schedule.h; time is simulated. Tasks take --seconds on average (lognormal), and one in
   six needs an earlier one, as in gsfix evaluate. Around each, its process takes --start seconds to begin and end.
   Rank 0 handles one message after the other, each in --message seconds: reports, and the signs of life that every rank at
   work sends once a second. Ranks are lost at random, each is missed after a minute, and comes back a minute later; what it
   did on its task is lost (really its task goes on from a checkpoint). Printed are the time until the last task has ended,
   beside that with all ranks at work all the time, the share of rank 0's time that messages take, how long a rank waits on
   average from its report to its next task, and the time that a decision really takes. */
typedef struct options { double ranks, tasks, seconds, start, message, lost_per_hour, seed; } options;
enum { EVENT_REPORT, EVENT_LOST, EVENT_MISSED, EVENT_BACK };
typedef struct event { double time; int kind; size_t worker, task; uint64_t life; } event;
typedef struct heap { event* items; size_t count, room; } heap;

static void push(heap* h, event e) {
    if (h->count == h->room) {
        h->room = 2 * h->room + 64;
        h->items = (event*)realloc(h->items, h->room * sizeof e);
        if (!h->items) exit(1);
    }
    size_t i = h->count++;
    for (; i && h->items[(i - 1) / 2].time > e.time; i = (i - 1) / 2) h->items[i] = h->items[(i - 1) / 2];
    h->items[i] = e;
}

static event pop(heap* h) {
    const event top = h->items[0], e = h->items[--h->count];
    size_t i = 0;
    for (size_t k; (k = 2 * i + 1) < h->count; i = k) {
        if (k + 1 < h->count && h->items[k + 1].time < h->items[k].time) k++;
        if (h->items[k].time >= e.time) break;
        h->items[i] = h->items[k];
    }
    h->items[i] = e;
    return top;
}

typedef struct rank_state { double begin, idle_since; uint64_t life; int busy, alive; } rank_state;

static void simulate(const options* o) {
    const size_t ranks = (size_t)o->ranks, tasks = (size_t)o->tasks;
    const uint64_t seed = (uint64_t)o->seed;
    double *work = (double*)calloc(tasks, sizeof *work), now = 0.0, chief = 0.0, useful = 0.0, wait = 0.0;
    size_t* needs = (size_t*)calloc(tasks, sizeof *needs);
    rank_state* r = (rank_state*)calloc(ranks, sizeof *r);
    heap h = {NULL, 0, 0};
    schedule s;
    uint64_t draws = 0, lost = 0, waits = 0;
    double handled = 0.0, decisions = 0.0;
    size_t steps = 0, idle = 0;
    if (!work || !needs || !r || !schedule_begin(&s, tasks, NULL, 0, 0.0)) exit(1);
    schedule_end(&s);
    for (size_t i = 0; i < tasks; i++) {
        work[i] = o->seconds * exp(0.6 * gsf_draw_normal(seed, 1, i) - 0.18);
        needs[i] = i % 6 == 5 ? i - 5 : i;
    }
    if (!schedule_begin(&s, tasks, needs, ranks, 0.0)) exit(1);
    for (size_t w = 0; w < ranks; w++) {
        r[w].alive = 1;
        idle++;
        const event e = {o->lost_per_hour > 0.0 ? -3600.0 / o->lost_per_hour * log(1.0 - gsf_draw_uniform(seed, 2, draws++))
                                                : INFINITY, EVENT_LOST, w, SCHEDULE_NONE, 0};
        push(&h, e);
    }
    while (!schedule_is_over(&s)) {
        // Ready tasks go to idle ranks, one message after the other.
        for (size_t w = 0; w < ranks && idle; w++) {
            if (!r[w].alive || r[w].busy) continue;
            const clock_t begin = clock();
            const size_t task = schedule_next(&s, w);
            decisions += (double)(clock() - begin) / CLOCKS_PER_SEC;
            steps++;
            if (task == SCHEDULE_NONE) break;
            chief = (chief > now ? chief : now) + o->message;
            handled += o->message;
            wait += chief - r[w].idle_since;
            waits++;
            r[w].busy = 1;
            idle--;
            r[w].begin = chief;
            const event e = {chief + o->start + work[task], EVENT_REPORT, w, task, r[w].life};
            push(&h, e);
        }
        const event e = pop(&h);
        rank_state* one = &r[e.worker];
        if (e.kind == EVENT_REPORT && e.life != one->life) continue; // was lost meanwhile
        now = e.time;
        if (e.kind == EVENT_REPORT) { // waits until rank 0 has handled what came before; signs of life of all ranks among it
            const double signs = (double)(ranks - idle) * o->message * (now - (chief < now ? chief : now));
            chief = (chief > now ? chief : now) + o->message * (1.0 + fmin(signs, 1.0));
            handled += o->message;
            one->busy = 0;
            one->idle_since = now;
            idle++;
            useful += work[e.task];
            const clock_t begin = clock();
            schedule_report(&s, e.worker, e.task, 1, NULL, NULL);
            decisions += (double)(clock() - begin) / CLOCKS_PER_SEC;
            now = chief;
        } else if (e.kind == EVENT_LOST) {
            const event missed = {now + 60.0, EVENT_MISSED, e.worker, SCHEDULE_NONE, one->life};
            lost++;
            idle -= (size_t)!one->busy;
            one->alive = 0;
            one->life++;
            push(&h, missed);
        } else if (e.kind == EVENT_MISSED) {
            const event back = {now + 60.0, EVENT_BACK, e.worker, SCHEDULE_NONE, one->life};
            schedule_lose(&s, e.worker, NULL, NULL);
            push(&h, back);
        } else {
            const event again = {now - 3600.0 / o->lost_per_hour * log(1.0 - gsf_draw_uniform(seed, 2, draws++)), EVENT_LOST,
                                 e.worker, SCHEDULE_NONE, one->life};
            schedule_hear(&s, e.worker, now);
            one->alive = 1;
            one->busy = 0;
            one->idle_since = now;
            idle++;
            push(&h, again);
        }
    }
    handled += o->message * useful; // a sign of life per rank and second of work
    printf("%zu ranks, %zu tasks of %.0f s: %.2f h, at best %.2f h; rank 0 busy %.2f %%; wait %.4f s; %llu ranks lost, %zu "
           "tasks failed; %.2f us per decision\n", ranks, tasks, o->seconds, now / 3600.0, useful / o->ranks / 3600.0,
           100.0 * handled / now, wait / (double)waits, (unsigned long long)lost, s.failed,
           1e6 * decisions / (double)(steps + tasks));
    schedule_end(&s);
    free(h.items);
    free(work);
    free(needs);
    free(r);
}

int main(int argc, char** argv) {
    static const char* const names[] = {"--ranks", "--tasks", "--seconds", "--start", "--message", "--lost-per-hour", "--seed"};
    options o = {1000, 30000, 300, 0.5, 20e-6, 0.1, 0};
    double* const fields[] = {&o.ranks, &o.tasks, &o.seconds, &o.start, &o.message, &o.lost_per_hour, &o.seed};
    for (int i = 1; i + 1 < argc; i += 2) {
        int k = 0;
        while (k < 7 && strcmp(names[k], argv[i]) != 0) k++;
        if (k == 7 || !((*fields[k] = strtod(argv[i + 1], NULL)) >= 0.0)) return fprintf(stderr, "no option %s\n", argv[i]), 2;
    }
    if (argc % 2 == 0 || o.ranks < 1 || o.tasks < 1) return fprintf(stderr, "see the head of simulate_ranks.c\n"), 2;
    simulate(&o);
    return 0;
}
