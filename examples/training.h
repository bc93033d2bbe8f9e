// training.h - what the trainers share: ranks, sums of gradients, losses. Part of train_mini.c and train_restorer.c.
// SPDX-License-Identifier: MIT
/* A batch is divided into `groups`, a power of two. Gradients add up within a group from example to example, and groups add up
   as a binary tree: (0 + 1) + (2 + 3) and so on. A rank of MPI takes a contiguous part of the groups, that is a subtree, and
   pairs of ranks exchange and add what they have, level by level. So the sums have the same bits for 1, 2, 4 ... ranks. It
   costs one more copy of the gradients for each level below a rank, and each level above it sends the gradients once.

   Every rank holds all weights and makes every update; rank 0 alone writes files. MPI is compiled in with GSF_USE_MPI and
   started only under mpirun. */
#ifndef TRAINING_H
#define TRAINING_H

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#ifdef GSF_USE_MPI
#include <mpi.h>
#endif

enum { TRAINING_GROUPS = 64, TRAINING_LEVELS = 6, TRAINING_PIECE = 1 << 18, TRAINING_PATH = 2048 };

// ---- ranks -----------------------------------------------------------------------

typedef struct training_ranks { int rank, count; } training_ranks;

// Under mpirun; all ranks then use the instructions that each of them has, as results depend on them.
static training_ranks training_begin(gsf_context* ctx, int* argc, char*** argv) {
    training_ranks ranks = {0, 1};
#ifdef GSF_USE_MPI
    if (getenv("OMPI_COMM_WORLD_SIZE") && MPI_Init(argc, argv) == MPI_SUCCESS) {
        int level = (int)ctx->cpu_level;
        MPI_Comm_rank(MPI_COMM_WORLD, &ranks.rank);
        MPI_Comm_size(MPI_COMM_WORLD, &ranks.count);
        MPI_Allreduce(MPI_IN_PLACE, &level, 1, MPI_INT, MPI_MIN, MPI_COMM_WORLD);
        ctx->cpu_level = (gsf_cpu_level)level;
    }
#endif
    (void)ctx, (void)argc, (void)argv;
    return ranks;
}

// The other ranks wait for one that failed, so that it must stop them.
static int training_end(training_ranks ranks, int status) {
#ifdef GSF_USE_MPI
    if (ranks.count > 1 && status) MPI_Abort(MPI_COMM_WORLD, status);
    int is_begun = 0;
    MPI_Initialized(&is_begun);
    if (is_begun) MPI_Finalize();
#endif
    (void)ranks;
    return status;
}

static void training_wait(training_ranks ranks) { // for all of them
#ifdef GSF_USE_MPI
    if (ranks.count > 1) MPI_Barrier(MPI_COMM_WORLD);
#endif
    (void)ranks;
}

// ---- sums ------------------------------------------------------------------------

typedef struct training_sum {
    training_ranks ranks;
    int groups, own;                   // of a batch; of this rank
    int64_t count;                     // values
    float* partial[TRAINING_LEVELS];   // sums of 1, 2, 4 ... groups that wait for their other half
    float* piece;                      // of another rank's sum
    double losses[TRAINING_GROUPS];    // of all groups
} training_sum;

static int training_is_power(int n) { return n > 0 && (n & (n - 1)) == 0; }

static int training_levels(int groups) { // of the tree above them
    int levels = 0;
    while (1 << levels < groups) levels++;
    return levels;
}

static gsf_result training_begin_sum(gsf_context* ctx, training_ranks ranks, int groups, int64_t count, training_sum* sum) {
    memset(sum, 0, sizeof *sum);
    sum->ranks = ranks;
    sum->groups = groups;
    sum->count = count;
    if (!training_is_power(groups) || groups > TRAINING_GROUPS || groups % ranks.count != 0 || !training_is_power(ranks.count))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "%d groups for %d ranks: both must be powers of two, and no more ranks than groups (--groups)", groups,
                        ranks.count);
    sum->own = groups / ranks.count;
    for (int i = 0; i < training_levels(sum->own); i++) {
        sum->partial[i] = (float*)gsf_alloc(ctx, (size_t)count, sizeof(float));
        if (!sum->partial[i]) return GSF_ERROR_OUT_OF_MEMORY;
    }
    if (ranks.count > 1) sum->piece = (float*)gsf_alloc(ctx, TRAINING_PIECE, sizeof(float));
    return ranks.count > 1 && !sum->piece ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

static void training_end_sum(gsf_context* ctx, training_sum* sum) {
    for (int i = 0; i < TRAINING_LEVELS; i++) gsf_free(ctx, sum->partial[i]);
    gsf_free(ctx, sum->piece);
    memset(sum, 0, sizeof *sum);
}

static void training_add(const float* first, int64_t count, float* second) {
    for (int64_t i = 0; i < count; i++) second[i] = first[i] + second[i];
}

// After the gradients of the rank's group `own`, counted from 0, with its loss; `grad` is then ready for the next group, or
// after the last one the sum of all of this rank's.
static void training_add_group(training_sum* sum, int own, double loss, float* grad) {
    int level = 0;
    sum->losses[sum->ranks.rank * sum->own + own] = loss;
    for (int rest = own; rest & 1; rest >>= 1) training_add(sum->partial[level++], sum->count, grad);
    if (own + 1 == sum->own) return;
    memcpy(sum->partial[level], grad, (size_t)sum->count * sizeof(float));
    memset(grad, 0, (size_t)sum->count * sizeof(float));
}

// Adds up what the ranks have; returns the sum of the losses.
static double training_add_ranks(training_sum* sum, float* grad) {
    double loss = 0.0;
#ifdef GSF_USE_MPI
    for (int bit = 1; bit < sum->ranks.count; bit <<= 1) {
        const int other = sum->ranks.rank ^ bit;
        for (int64_t at = 0; at < sum->count; at += TRAINING_PIECE) {
            const int64_t left = sum->count - at, count = left < TRAINING_PIECE ? left : TRAINING_PIECE;
            MPI_Sendrecv(grad + at, (int)count, MPI_FLOAT, other, 0, sum->piece, (int)count, MPI_FLOAT, other, 0,
                         MPI_COMM_WORLD, MPI_STATUS_IGNORE);
            training_add(sum->piece, count, grad + at);
        }
    }
    if (sum->ranks.count > 1)
        MPI_Allgather(MPI_IN_PLACE, 0, MPI_DATATYPE_NULL, sum->losses, sum->own, MPI_DOUBLE, MPI_COMM_WORLD);
#endif
    (void)grad;
    for (int i = 0; i < sum->groups; i++) loss += sum->losses[i];
    return loss;
}

// ---- losses ----------------------------------------------------------------------

/* OUT.loss.csv has the loss of every step, OUT.loss.html their curve. They are written just before the state that a run is
   resumed from, so that they reach at least as far. */
typedef struct training_log {
    double* losses;
    int64_t count, room;
} training_log;

static gsf_result training_keep_loss(gsf_context* ctx, training_log* log, double loss) {
    if (log->count == log->room) {
        const int64_t room = log->room ? 2 * log->room : 1024;
        double* more = (double*)gsf_alloc(ctx, (size_t)room, sizeof *more);
        if (!more) return GSF_ERROR_OUT_OF_MEMORY;
        if (log->count) memcpy(more, log->losses, (size_t)log->count * sizeof *more);
        gsf_free(ctx, log->losses);
        log->losses = more;
        log->room = room;
    }
    log->losses[log->count++] = loss;
    return GSF_OK;
}

// The losses of the first `steps` steps, of a run that goes on.
static gsf_result training_load_log(gsf_context* ctx, const char* out, int64_t steps, training_log* log) {
    char path[TRAINING_PATH + 16];
    void* text;
    size_t size;
    snprintf(path, sizeof path, "%s.loss.csv", out);
    gsf_result result = gsf_read_file(ctx, path, &text, &size);
    if (result != GSF_OK) return result;
    char* copy = (char*)gsf_alloc(ctx, size + 1, 1);
    if (copy) memcpy(copy, text, size);
    else result = GSF_ERROR_OUT_OF_MEMORY;
    gsf_free(ctx, text);
    if (result != GSF_OK) return result;
    copy[size] = 0;
    const char* at = strchr(copy, '\n');
    while (at && result == GSF_OK && log->count < steps) {
        const char* comma = strchr(at, ',');
        char* end = NULL;
        const double loss = comma ? strtod(comma + 1, &end) : 0.0;
        if (!comma || end == comma + 1) break;
        result = training_keep_loss(ctx, log, loss);
        at = strchr(end, '\n');
    }
    gsf_free(ctx, copy);
    if (result == GSF_OK && log->count < steps)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: losses of %lld steps, but the state is at step %lld", path,
                          (long long)log->count, (long long)steps);
    return result;
}

enum { CURVE_WIDTH = 860, CURVE_HEIGHT = 320, CURVE_LEFT = 70, CURVE_TOP = 20, CURVE_POINTS = 400 };

// Means of up to CURVE_POINTS equal parts of the run, over the logarithm of the loss.
static void training_draw_curve(gsf_context* ctx, const training_log* log, gsf_buffer* page) {
    const int64_t part = (log->count + CURVE_POINTS - 1) / CURVE_POINTS;
    double low = HUGE_VAL, high = 0.0;
    for (int pass = 0; pass < 2; pass++) {
        const double floor_ = low > 1e-30 ? log10(low) : -30.0, ceiling = high > low ? log10(high) : floor_ + 1.0;
        for (int64_t i = 0; i < log->count; i += part) {
            const int64_t end = i + part < log->count ? i + part : log->count;
            double mean = 0.0;
            for (int64_t k = i; k < end; k++) mean += log->losses[k] / (double)(end - i);
            if (!pass) {
                low = mean < low ? mean : low;
                high = mean > high ? mean : high;
                continue;
            }
            const double x = CURVE_LEFT + (double)CURVE_WIDTH * 0.5 * (double)(i + end) / (double)log->count;
            const double y = CURVE_TOP + CURVE_HEIGHT * (ceiling - log10(mean > 1e-30 ? mean : 1e-30)) / (ceiling - floor_);
            gsf_append_text(ctx, page, "%.1f,%.1f ", x, y);
        }
    }
    gsf_append_text(ctx, page, "\"/>\n<text x=\"5\" y=\"%d\">%.4g</text><text x=\"5\" y=\"%d\">%.4g</text>\n", CURVE_TOP + 10,
                    high, CURVE_TOP + CURVE_HEIGHT, low);
}

static gsf_result training_save_log(gsf_context* ctx, const char* out, const char* name, const training_log* log) {
    char path[TRAINING_PATH + 16];
    gsf_buffer text, page;
    memset(&text, 0, sizeof text);
    memset(&page, 0, sizeof page);
    gsf_append_text(ctx, &text, "step,loss\n");
    for (int64_t i = 0; i < log->count; i++) gsf_append_text(ctx, &text, "%lld,%.17g\n", (long long)i + 1, log->losses[i]);
    gsf_append_text(ctx, &page,
                    "<!doctype html>\n<meta charset=\"utf-8\">\n<title>%s: loss</title>\n"
                    "<style>body{font:14px system-ui,sans-serif;margin:2em}svg{max-width:100%%}polyline{fill:none;stroke:#06c}"
                    "line{stroke:#999}</style>\n<h1>%s: loss of %lld steps</h1>\n<svg viewBox=\"0 0 %d %d\">\n"
                    "<line x1=\"%d\" y1=\"%d\" x2=\"%d\" y2=\"%d\"/><line x1=\"%d\" y1=\"%d\" x2=\"%d\" y2=\"%d\"/>\n"
                    "<polyline points=\"",
                    name, name, (long long)log->count, CURVE_LEFT + CURVE_WIDTH + 10, CURVE_TOP + CURVE_HEIGHT + 30, CURVE_LEFT,
                    CURVE_TOP, CURVE_LEFT, CURVE_TOP + CURVE_HEIGHT, CURVE_LEFT, CURVE_TOP + CURVE_HEIGHT,
                    CURVE_LEFT + CURVE_WIDTH, CURVE_TOP + CURVE_HEIGHT);
    training_draw_curve(ctx, log, &page);
    gsf_append_text(ctx, &page, "<text x=\"%d\" y=\"%d\" text-anchor=\"end\">step %lld</text>\n</svg>\n",
                    CURVE_LEFT + CURVE_WIDTH, CURVE_TOP + CURVE_HEIGHT + 20, (long long)log->count);
    gsf_result result = text.failed || page.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    snprintf(path, sizeof path, "%s.loss.csv", out);
    if (result == GSF_OK) result = gsf_write_file(ctx, path, text.data, text.size);
    snprintf(path, sizeof path, "%s.loss.html", out);
    if (result == GSF_OK) result = gsf_write_file(ctx, path, page.data, page.size);
    gsf_destroy_buffer(ctx, &text);
    gsf_destroy_buffer(ctx, &page);
    return result;
}

static double training_cpu_minutes(void) { return (double)clock() / CLOCKS_PER_SEC / 60.0; }

#endif // TRAINING_H
