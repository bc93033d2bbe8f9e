// worker_runs.h - runs the same work with 1, 2 and 3 workers of a pthread job system and compares the outputs byte by byte.
// Include after examples/job_system.c (with JOB_SYSTEM_ONLY) and test.h.
#ifndef WORKER_RUNS_H
#define WORKER_RUNS_H

typedef struct stage_output { // bytes of one stage, all outputs one after another
    const char* stage;
    char* data;
    size_t size, capacity;
} stage_output;

enum { STAGES_MAX = 16 };
typedef struct run_output { stage_output stages[STAGES_MAX]; int count; } run_output;

static stage_output* begin_stage(run_output* run, const char* stage) {
    stage_output* out = &run->stages[run->count++];
    out->stage = stage;
    return out;
}

static void add(stage_output* out, const void* data, size_t size) {
    if (out->size + size > out->capacity) {
        out->capacity = 2 * (out->size + size);
        out->data = (char*)realloc(out->data, out->capacity);
    }
    memcpy(out->data + out->size, data, size);
    out->size += size;
}

static void start_run(int workers, void (*work)(gsf_context*, run_output*), run_output* run) {
    job_system jobs;
    memset(run, 0, sizeof *run);
    if (!CHECK(job_start(&jobs, workers))) return;
    gsf_context ctx;
    test_context_zero(&ctx);
    ctx.parallel.for_fn = job_for;
    ctx.parallel.user = &jobs;
    ctx.parallel.worker_count = workers;
    if (CHECK_OK(&ctx, gsf_init_context(&ctx))) work(&ctx, run);
    job_stop(&jobs);
}

static void free_run(run_output* run) {
    for (int i = 0; i < run->count; i++) free(run->stages[i].data);
}

static void compare_runs(void (*work)(gsf_context*, run_output*)) {
    run_output one, more;
    start_run(1, work, &one);
    CHECK(one.count > 0);
    for (int workers = 2; workers <= 3; workers++) {
        start_run(workers, work, &more);
        CHECK(more.count == one.count);
        for (int i = 0; i < one.count && i < more.count; i++) {
            const stage_output *a = &one.stages[i], *b = &more.stages[i];
            CHECK(a->size > 0);
            size_t same = 0;
            while (same < a->size && same < b->size && a->data[same] == b->data[same]) same++;
            if (!CHECK(a->size == b->size && same == a->size))
                fprintf(stderr, "%s: %d workers differ from 1 at byte %zu of %zu\n", a->stage, workers, same, a->size);
        }
        free_run(&more);
    }
    free_run(&one);
}

#endif
