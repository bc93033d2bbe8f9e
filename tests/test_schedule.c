// test_schedule.c - gsfix_mpi's schedule against workers that are lost, come back, fail and report twice
// SPDX-License-Identifier: MIT
#include "../examples/gsfix_schedule.h"

#include "gsfixer.h"

#include "test.h"

typedef struct ended { int count[600], ok[600]; size_t calls; } ended;

static void on_end(void* user, size_t task, int ok) {
    ended* e = (ended*)user;
    e->count[task]++;
    e->ok[task] = ok;
    e->calls++;
}

static void test_order(void) { // in order, and only after what is needed
    const size_t needs[] = {0, 0, 2, 1, 4};
    static ended e;
    schedule s;
    CHECK(schedule_begin(&s, 5, needs, 2, 0.0));
    CHECK(schedule_next(&s, 0) == 0);
    CHECK(schedule_next(&s, 1) == 2);
    schedule_report(&s, 1, 2, 1, on_end, &e);
    CHECK(schedule_next(&s, 1) == 4);
    schedule_report(&s, 1, 4, 1, on_end, &e);
    CHECK(schedule_next(&s, 1) == SCHEDULE_NONE && !schedule_is_over(&s));
    schedule_report(&s, 0, 0, 1, on_end, &e);
    CHECK(schedule_next(&s, 1) == 1);
    CHECK(schedule_next(&s, 0) == SCHEDULE_NONE);
    schedule_report(&s, 1, 1, 0, on_end, &e); // its failure is also that of 3
    CHECK(schedule_is_over(&s) && s.failed == 2 && e.calls == 5);
    CHECK(e.ok[0] && !e.ok[1] && e.ok[2] && !e.ok[3] && e.ok[4]);
    schedule_end(&s);
}

static void test_lost(void) { // a lost worker's task goes to another one; the first success counts
    static ended e;
    schedule s;
    CHECK(schedule_begin(&s, 1, NULL, 2, 0.0));
    CHECK(schedule_next(&s, 0) == 0);
    schedule_lose(&s, 0, on_end, &e);
    CHECK(s.alive == 1);
    CHECK(schedule_next(&s, 1) == 0);
    schedule_hear(&s, 0, 1.0);
    CHECK(s.alive == 2);
    schedule_report(&s, 0, 0, 0, on_end, &e); // a failure of a task that is no longer its own does not count
    CHECK(!schedule_is_over(&s));
    schedule_report(&s, 0, 0, 1, on_end, &e);
    CHECK(schedule_is_over(&s) && e.count[0] == 1 && e.ok[0]);
    schedule_report(&s, 1, 0, 0, on_end, &e);
    CHECK(e.count[0] == 1 && s.failed == 0);
    schedule_end(&s);
    memset(&e, 0, sizeof e);
    CHECK(schedule_begin(&s, 1, NULL, 1, 0.0));
    for (int i = 0; i < SCHEDULE_TRIES; i++) {
        CHECK(!schedule_is_over(&s) && schedule_next(&s, 0) == 0);
        schedule_retry(&s, 0, on_end, &e);
    }
    CHECK(schedule_is_over(&s) && s.failed == 1 && !e.ok[0]); // given up
    schedule_end(&s);
}

// Random events: in the end each task has ended once, successes only after what they need.
static void test_events(uint64_t seed) {
    enum { TASKS = 600, WORKERS = 40 };
    static ended e;
    size_t needs[TASKS], current[WORKERS];
    schedule s;
    memset(&e, 0, sizeof e);
    for (size_t i = 0; i < TASKS; i++)
        needs[i] = i && gsf_draw_uniform(seed, 1, i) < 0.4 ? (size_t)(gsf_draw_uniform(seed, 2, i) * (double)i) : i;
    CHECK(schedule_begin(&s, TASKS, needs, WORKERS, 0.0));
    for (int w = 0; w < WORKERS; w++) current[w] = SCHEDULE_NONE;
    for (uint64_t step = 0; !schedule_is_over(&s) && step < 200000; step++) {
        const size_t w = (size_t)(gsf_draw_uniform(seed, 3, step) * WORKERS);
        const double what = gsf_draw_uniform(seed, 4, step);
        if (current[w] == SCHEDULE_NONE) {
            if (s.workers[w].lost) schedule_hear(&s, w, 0.0);
            if ((current[w] = schedule_next(&s, w)) == SCHEDULE_NONE) continue;
            CHECK(needs[current[w]] == current[w] || e.ok[needs[current[w]]]);
        } else if (what < 0.9) {
            if (s.workers[w].lost) schedule_hear(&s, w, 0.0);
            schedule_report(&s, w, current[w], what > 0.02, on_end, &e);
            current[w] = SCHEDULE_NONE;
        } else if (what < 0.95) {
            schedule_lose(&s, w, on_end, &e);
            if (what < 0.93) current[w] = SCHEDULE_NONE; // else it still works, and reports later
        } else {
            schedule_retry(&s, w, on_end, &e);
            current[w] = SCHEDULE_NONE;
        }
    }
    CHECK(schedule_is_over(&s) && e.calls == TASKS);
    size_t failed = 0;
    for (size_t i = 0; i < TASKS; i++) {
        CHECK(e.count[i] == 1);
        CHECK(!e.ok[i] || needs[i] == i || e.ok[needs[i]]);
        failed += !e.ok[i];
    }
    CHECK(failed == s.failed);
    schedule_end(&s);
}

int main(void) {
    test_order();
    test_lost();
    for (uint64_t seed = 0; seed < 20; seed++) test_events(seed);
    return test_report();
}
