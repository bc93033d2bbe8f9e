// job_system.c - cc -O2 -std=c11 -DGSFIXER_IMPLEMENTATION -I. examples/job_system.c -o job_system -lpthread -lm
// A host's own job system behind the parallel hook, here a small pool of POSIX threads. Renders random splats with one
// worker and with four and compares: the images are bit-identical.
#define _POSIX_C_SOURCE 200809L
#include "gsfixer_splat.h"
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { JOB_WORKERS_MAX = 64 };

typedef struct job_system {
    pthread_mutex_t lock; // guards everything below
    pthread_cond_t start, done;
    pthread_t threads[JOB_WORKERS_MAX];
    int32_t worker_count; // including the caller, which is worker 0
    int busy, quit;
    unsigned round; // counts the calls of job_for
    size_t count, next;
    gsf_chunk_fn body;
    void* arg;
} job_system;

typedef struct job_worker { job_system* jobs; int index; } job_worker;

static void job_take_chunks(job_system* jobs, int32_t worker) { // called and returns with the lock held
    while (jobs->next < jobs->count) {
        const size_t chunk = jobs->next++;
        pthread_mutex_unlock(&jobs->lock);
        jobs->body(jobs->arg, chunk, worker);
        pthread_mutex_lock(&jobs->lock);
    }
}

static void* job_thread(void* arg) {
    const job_worker worker = *(job_worker*)arg;
    job_system* jobs = worker.jobs;
    free(arg);
    unsigned seen = 0;
    pthread_mutex_lock(&jobs->lock);
    while (!jobs->quit) {
        if (jobs->round == seen) {
            pthread_cond_wait(&jobs->start, &jobs->lock);
            continue;
        }
        seen = jobs->round;
        jobs->busy++;
        job_take_chunks(jobs, worker.index);
        if (--jobs->busy == 0) pthread_cond_signal(&jobs->done);
    }
    pthread_mutex_unlock(&jobs->lock);
    return NULL;
}

// The hook: returns when all chunks are done. A thread that wakes up late finds no chunks left and does nothing.
static void job_for(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    job_system* jobs = (job_system*)user;
    pthread_mutex_lock(&jobs->lock);
    jobs->body = body;
    jobs->arg = arg;
    jobs->count = chunk_count;
    jobs->next = 0;
    jobs->round++;
    pthread_cond_broadcast(&jobs->start);
    job_take_chunks(jobs, 0);
    while (jobs->busy > 0) pthread_cond_wait(&jobs->done, &jobs->lock);
    jobs->count = 0;
    pthread_mutex_unlock(&jobs->lock);
}

static void job_stop(job_system* jobs) {
    pthread_mutex_lock(&jobs->lock);
    jobs->quit = 1;
    pthread_cond_broadcast(&jobs->start);
    pthread_mutex_unlock(&jobs->lock);
    for (int i = 1; i < jobs->worker_count; i++) pthread_join(jobs->threads[i], NULL);
    pthread_cond_destroy(&jobs->done);
    pthread_cond_destroy(&jobs->start);
    pthread_mutex_destroy(&jobs->lock);
}

static int job_start(job_system* jobs, int32_t worker_count) { // 0 on failure
    memset(jobs, 0, sizeof *jobs);
    if (worker_count < 1 || worker_count > JOB_WORKERS_MAX) return 0;
    if (pthread_mutex_init(&jobs->lock, NULL)) return 0;
    if (pthread_cond_init(&jobs->start, NULL) || pthread_cond_init(&jobs->done, NULL)) return 0;
    for (jobs->worker_count = 1; jobs->worker_count < worker_count; jobs->worker_count++) {
        job_worker* worker = (job_worker*)malloc(sizeof *worker);
        if (worker) *worker = (job_worker){jobs, jobs->worker_count};
        if (!worker || pthread_create(&jobs->threads[worker->index], NULL, job_thread, worker) != 0) {
            free(worker);
            job_stop(jobs); // stops the threads that have been started
            return 0;
        }
    }
    return 1;
}

#ifndef JOB_SYSTEM_ONLY // define it to include only the pool
enum { WIDTH = 320, HEIGHT = 240, SPLATS = 3000 };

static gsf_result render_random_splats(gsf_context* ctx, float* pixels) {
    gsf_splats splats;
    gsf_result result = gsf_splat_make(ctx, SPLATS, 0, &splats);
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < SPLATS; i++) {
        for (uint64_t a = 0; a < 3; a++) {
            splats.means[3 * i + a] = (float)(2.0 * gsf_draw_uniform(1, a, i) - 1.0);
            splats.log_scales[3 * i + a] = (float)(-4.5 + gsf_draw_uniform(1, 3 + a, i));
            splats.sh[3 * i + a] = (float)gsf_draw_normal(1, 6 + a, i);
        }
        splats.quats[4 * i] = 1.0f;
        splats.opacity_logits[i] = 1.0f;
    }
    const gsf_camera camera = {{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 3, 1}, 300, 300, 160, 120, WIDTH, HEIGHT};
    gsf_rasterizer* rasterizer = NULL;
    result = gsf_splat_make_rasterizer(ctx, &rasterizer);
    if (result == GSF_OK) {
        gsf_render_output out = {0};
        out.color = gsf_wrap_image(pixels, GSF_F32, WIDTH, HEIGHT, 3);
        result = gsf_splat_render(ctx, rasterizer, &splats, &camera, NULL, &out);
        gsf_splat_destroy_rasterizer(ctx, rasterizer);
    }
    gsf_splat_destroy(ctx, &splats);
    return result;
}

int main(void) {
    static float pixels[2][WIDTH * HEIGHT * 3];
    for (int i = 0; i < 2; i++) {
        job_system jobs;
        if (!job_start(&jobs, i ? 4 : 1)) return fprintf(stderr, "threads cannot be started\n"), 1;
        gsf_context ctx = {0};
        ctx.parallel.for_fn = job_for;
        ctx.parallel.user = &jobs;
        ctx.parallel.worker_count = jobs.worker_count;
        gsf_result result = gsf_init_context(&ctx);
        if (result == GSF_OK) result = render_random_splats(&ctx, pixels[i]);
        job_stop(&jobs);
        if (result != GSF_OK) return fprintf(stderr, "%s\n", ctx.error), 1;
    }
    const int same = memcmp(pixels[0], pixels[1], sizeof pixels[0]) == 0;
    printf("1 worker and 4 workers: %s\n", same ? "bit-identical images" : "DIFFERENT images");
    return same ? 0 : 1;
}
#endif
