// train_block.c - one block of the paper's transformer, forwards and backwards, timed; for train_block_peer.py, which
// compiles it. By hand: cc -O2 -std=c11 -fopenmp -I. bench/train_block.c -o train_block -lm
//
//     train_block MODEL OUT.safetensors [--frames 5] [--height 4] [--width 166] [--references 1850] [--runs 3] [--threads 1]
//         [--bf16 0]
//
// MODEL: made by make_model --size full --layers 1 --parts transformer. Runs its first block in float32, or with products of
// bf16, on normal noise, with 226 tokens of text and frames * height * width / 4 of video, and prints the CPU seconds of each
// run. OUT gets what went in and what came out: x, references, time, cos, sin, dy; dx, dreferences, dtime and the gradients of
// the block's weights.
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#ifndef GSFIXER_STATIC
#define GSFIXER_STATIC
#endif
#include "gsfixer_nn.h"

#include <stdio.h>
#include <time.h>

typedef struct block_run {
    gsf_context ctx;
    gsf_nn_transformer net;
    gsf__nn_params params;
    gsf__dit_train t;
    gsf_nn_transformer_desc in;
    float *memory, *x, *dy;
    double timestep;
    int bf16;
} block_run;

static int trains(const char* name) { return strncmp(name, "transformer_blocks.0.", 21) == 0; }

static float* fill(block_run* r, int64_t count, uint64_t stream, float* out) {
    for (int64_t i = 0; i < count && out; i++) out[i] = (float)gsf_draw_normal(1, stream, (uint64_t)i);
    (void)r;
    return out;
}

static gsf_result open_run(block_run* r, const char* model, const int64_t size[4]) {
    gsf_context* ctx = &r->ctx;
    char path[2048];
    snprintf(path, sizeof path, "%s/transformer", model);
    gsf_result result = gsf_nn_load_transformer(ctx, path, &r->net);
    if (result == GSF_OK) result = gsf__nn_make_params(ctx, &r->net.weights, trains, 0, &r->params);
    if (result != GSF_OK) return result;
    r->in.batch = r->in.reference_batch = 1;
    r->in.frames = (int32_t)size[0];
    r->in.height = (int32_t)size[1];
    r->in.width = (int32_t)size[2];
    r->in.reference_tokens = size[3];
    r->in.timesteps = &r->timestep;
    r->in.references = r->params.value; // until there is memory
    gsf__dit_begin_run(&r->t.run, ctx, &r->net);
    gsf__dit_set_input(&r->t.run, &r->in);
    r->t.run.nn.bf16 = r->bf16 ? GSF__NN_BF16_ALL : 0;
    r->t.params = &r->params;
    r->memory = (float*)gsf_alloc(ctx, gsf__dit_lay_out_train(&r->t, NULL), sizeof(float));
    if (!r->memory) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__dit_lay_out_train(&r->t, r->memory);
    r->in.references = r->t.references;
    const int64_t d = r->t.run.width, n = r->t.run.tokens;
    r->x = fill(r, n * d, 1, (float*)gsf_alloc(ctx, (size_t)(n * d), sizeof(float)));
    r->dy = fill(r, n * d, 2, (float*)gsf_alloc(ctx, (size_t)(n * d), sizeof(float)));
    if (!r->x || !r->dy) return GSF_ERROR_OUT_OF_MEMORY;
    fill(r, size[3] * d, 3, r->t.references);
    fill(r, r->net.time_channels, 4, r->t.run.time);
    return gsf__dit_make_rope(&r->t.run);
}

static gsf_result run_block(block_run* r, double* seconds) {
    const gsf__dit_block* block = &r->t.run.nets->blocks[0];
    const size_t d = (size_t)r->t.run.width, n = (size_t)r->t.run.tokens;
    memset(r->params.grad, 0, (size_t)r->params.count * sizeof(float));
    memset(r->t.dtime, 0, (size_t)r->net.time_channels * sizeof(float));
    memset(r->t.dreferences, 0, (size_t)r->in.reference_tokens * d * sizeof(float));
    memcpy(r->t.dx, r->dy, n * d * sizeof(float));
    const clock_t start = clock();
    gsf_result result = gsf__dit_trace_block(&r->t, block, r->x);
    if (result == GSF_OK) result = gsf__dit_block_backward(&r->t, block, r->x);
    *seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
    return result;
}

static gsf_result save_run(block_run* r, const char* path) {
    const gsf__dit_train* t = &r->t;
    const int64_t n = t->run.tokens, d = t->run.width, k = r->in.reference_tokens, video = t->run.video;
    const struct { const char* name; const float* data; int64_t rows, columns; } parts[] = {
        {"x", r->x, n, d}, {"dy", r->dy, n, d}, {"dx", t->dx, n, d}, {"references", t->references, k, d},
        {"dreferences", t->dreferences, k, d}, {"time", t->run.time, 1, r->net.time_channels},
        {"dtime", t->dtime, 1, r->net.time_channels}, {"cos", t->run.cos, video, r->net.head_dim},
        {"sin", t->run.sin, video, r->net.head_dim}};
    const size_t count = sizeof parts / sizeof *parts;
    gsf_nn_tensor* all = (gsf_nn_tensor*)gsf_alloc(&r->ctx, count + r->net.weights.tensor_count, sizeof *all);
    size_t used = count;
    if (!all) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) {
        const int64_t shape[2] = {parts[i].rows, parts[i].columns};
        all[i] = gsf_nn_wrap_tensor(parts[i].name, parts[i].data, 2, shape);
    }
    for (size_t i = 0; i < r->net.weights.tensor_count; i++) {
        if (r->params.at[i] < 0) continue;
        all[used] = r->net.weights.tensors[i];
        all[used++].data = r->params.grad + r->params.at[i];
    }
    const gsf_result result = gsf_nn_save_tensors(&r->ctx, path, all, used);
    gsf_free(&r->ctx, all);
    return result;
}

int main(int argc, char** argv) {
    static block_run r;
    static const char* const names[] = {"--frames", "--height", "--width", "--references", "--runs", "--threads", "--bf16"};
    int64_t values[7] = {5, 4, 166, 1850, 3, 1, 0};
    int bad = argc < 3;
    for (int i = 3; i < argc; i += 2) {
        int known = 0;
        for (int k = 0; k < 7 && i + 1 < argc; k++)
            if (strcmp(argv[i], names[k]) == 0) values[k] = atoi(argv[i + 1]), known = 1;
        bad |= !known;
    }
    for (int k = 0; k < 6; k++) bad |= values[k] < 1;
    if (bad) {
        fprintf(stderr, "usage: train_block MODEL OUT [--frames F] [--height H] [--width W] [--references R] [--runs N] "
                        "[--threads T] [--bf16 1]\n");
        return 2;
    }
    r.ctx.threads = (int32_t)values[5];
    r.bf16 = values[6] != 0;
    gsf_result result = gsf_init_context(&r.ctx);
    if (result == GSF_OK) result = open_run(&r, argv[1], values);
    for (int64_t i = 0; i < values[4] && result == GSF_OK; i++) {
        double seconds;
        result = run_block(&r, &seconds);
        if (result == GSF_OK) printf("%lld tokens, %.3f CPU seconds\n", (long long)r.t.run.tokens, seconds);
        fflush(stdout);
    }
    if (result == GSF_OK) result = save_run(&r, argv[2]);
    if (result != GSF_OK) fprintf(stderr, "train_block: %s\n", r.ctx.error);
    gsf__nn_destroy_workspace(&r.ctx, &r.t.run.nn.workspace);
    gsf_free(&r.ctx, r.memory);
    gsf_free(&r.ctx, r.x);
    gsf_free(&r.ctx, r.dy);
    gsf__nn_destroy_params(&r.ctx, &r.params);
    gsf_nn_destroy_transformer(&r.ctx, &r.net);
    return result == GSF_OK ? 0 : 1;
}
