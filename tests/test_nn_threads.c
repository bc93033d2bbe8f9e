// The networks on a pthread job system behind the parallel hook: 1, 2 and 3 workers give the same bytes, kernel by
// kernel and for a complete run of the small golden model. Built with ThreadSanitizer, this is also the test for data
// races.
#define GSFIXER_IMPLEMENTATION
#define JOB_SYSTEM_ONLY
#include "../examples/job_system.c"
#include "gsfixer_nn.h"
#include "test.h"
#include "worker_runs.h"

static float* make_floats(int64_t count, uint64_t stream) { // in [-1, 1)
    float* v = (float*)malloc((size_t)count * sizeof(float));
    for (int64_t i = 0; i < count; i++) v[i] = (float)(2.0 * gsf_draw_uniform(3, stream, (uint64_t)i) - 1.0);
    return v;
}

static void add_floats(stage_output* out, const float* v, int64_t count) { add(out, v, (size_t)count * sizeof(float)); }

static gsf_nn_tensor make_weight(const float* v, int64_t a, int64_t b, int64_t c) { // (a, b); c: (a, b, c, 3, 3)
    const int64_t shape[5] = {a, b, c, 3, 3};
    return gsf_nn_wrap_tensor("weight", v, c ? 5 : 2, shape);
}

// ---- kernels -----------------------------------------------------------------------

static void run_linear(gsf_context* ctx, run_output* run) {
    enum { ROWS = 333, SOURCE = 160, RESULT = 272 };
    stage_output* out = begin_stage(run, "linear");
    float *x = make_floats(ROWS * SOURCE, 0), *w = make_floats(RESULT * SOURCE, 1), *y = make_floats(ROWS * RESULT, 2);
    const gsf_nn_tensor weight = make_weight(w, RESULT, SOURCE, 0);
    gsf__nn_quantized quantized;
    gsf__nn_linear_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.rows = ROWS;
    d.weight = &weight;
    d.activation = GSF__NN_GELU_TANH;
    d.accumulate = 1;
    d.y = y;
    CHECK_OK(ctx, gsf__nn_run_linear(ctx, NULL, &d));
    d.rows = 2; // few rows take the GEMV kernels
    CHECK_OK(ctx, gsf__nn_run_linear(ctx, NULL, &d));
    d.rows = ROWS;
    if (CHECK_OK(ctx, gsf__nn_quantize_weight(ctx, &weight, 0, &quantized))) {
        CHECK_OK(ctx, gsf__nn_run_linear_int8(ctx, NULL, &d, &quantized));
        add(out, quantized.data, RESULT * SOURCE);
        gsf__nn_destroy_quantized(ctx, &quantized);
    }
    add_floats(out, y, ROWS * RESULT);
    free(x);
    free(w);
    free(y);
}

static void run_attention(gsf_context* ctx, run_output* run) {
    enum { QUERIES = 210, KEYS = 333, HEADS = 3, DIM = 64, WIDTH = HEADS * DIM };
    stage_output* out = begin_stage(run, "attention");
    float *q = make_floats(QUERIES * WIDTH, 3), *k = make_floats(KEYS * WIDTH, 4), *v = make_floats(KEYS * WIDTH, 5);
    gsf__nn_attention_desc d;
    memset(&d, 0, sizeof d);
    d.queries = QUERIES;
    d.keys = KEYS;
    d.heads = HEADS;
    d.head_dim = DIM;
    d.q = q;
    d.k = k;
    d.v = v;
    d.out = q;
    CHECK_OK(ctx, gsf__nn_run_attention(ctx, NULL, &d));
    add_floats(out, q, QUERIES * WIDTH);
    free(q);
    free(k);
    free(v);
}

static void run_norms(gsf_context* ctx, run_output* run) {
    enum { ROWS = 700, HEADS = 3, HEAD = 32, DIM = HEADS * HEAD, GROUPS = 4 };
    stage_output* out = begin_stage(run, "norms");
    float *x = make_floats(ROWS * DIM, 6), *a = make_floats(ROWS * DIM, 7), *b = make_floats(ROWS * DIM, 8);
    gsf__nn_layer_norm(ctx, x, ROWS, DIM, a, b, 1e-5f, x);
    gsf__nn_rms_norm(ctx, x, ROWS, DIM, a, 1e-6f, x);
    gsf__nn_layer_norm_modulated(ctx, x, ROWS, DIM, a, b, 1e-5f, a + DIM, b + DIM, x);
    gsf__nn_group_norm(ctx, x, ROWS, DIM, GROUPS, a, b, 1e-6f, x);
    gsf__nn_head_norm_rope(ctx, x, ROWS, DIM, HEADS, HEAD, a, b, 1e-6f, a, b, 10);
    gsf__nn_softmax(ctx, x, ROWS, DIM, 0.5f, a);
    gsf__nn_activate(ctx, GSF__NN_SILU, x, ROWS * DIM, b);
    add_floats(out, x, ROWS * DIM);
    add_floats(out, a, ROWS * DIM);
    add_floats(out, b, ROWS * DIM);
    free(x);
    free(a);
    free(b);
}

static void run_convolution(gsf_context* ctx, run_output* run) {
    enum { FRAMES = 3, H = 19, W = 22, SOURCE = 20, RESULT = 24 };
    stage_output* out = begin_stage(run, "convolution");
    float *x = make_floats(FRAMES * H * W * SOURCE, 9), *w = make_floats(RESULT * SOURCE * 27, 10);
    float* y = make_floats(FRAMES * H * W * RESULT, 11);
    const gsf_nn_tensor weight = make_weight(w, RESULT, SOURCE, 3);
    gsf__nn_conv_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.frames = FRAMES;
    d.height = H;
    d.width = W;
    d.weight = &weight;
    d.accumulate = 1;
    d.y = y;
    CHECK_OK(ctx, gsf__nn_convolve(ctx, NULL, &d));
    add_floats(out, y, FRAMES * H * W * RESULT);
    free(x);
    free(w);
    free(y);
}

// ---- the golden model ----------------------------------------------------------------

typedef struct model {
    gsf_nn_transformer transformer;
    gsf_nn_vae vae;
    gsf_nn_schedule schedule;
} model;

static int open_model(gsf_context* ctx, model* m) {
    memset(m, 0, sizeof *m);
    return CHECK_OK(ctx, gsf_nn_load_transformer(ctx, test_golden("restorer/model/transformer"), &m->transformer)) &&
           CHECK_OK(ctx, gsf_nn_load_vae(ctx, test_golden("restorer/model/vae"), &m->vae)) &&
           CHECK_OK(ctx, gsf_nn_load_schedule(ctx, test_golden("restorer/model/scheduler/scheduler_config.json"),
                                              &m->schedule));
}

static void close_model(gsf_context* ctx, model* m) {
    gsf_nn_destroy_transformer(ctx, &m->transformer);
    gsf_nn_destroy_vae(ctx, &m->vae);
    gsf_nn_destroy_schedule(ctx, &m->schedule);
}

// Encoder, a step of the transformer, decoder; and the transformer alone in 8 bits.
static void run_sampling(gsf_context* ctx, run_output* run, model* m) {
    enum { TOKENS = 12 };
    const gsf_nn_transformer* t = &m->transformer;
    const int64_t width = (int64_t)t->heads * t->head_dim;
    gsf_nn_sample_desc d;
    memset(&d, 0, sizeof d);
    d.frames = t->sample_frames;
    d.height = t->sample_height * m->vae.spatial_ratio;
    d.width = t->sample_width * m->vae.spatial_ratio;
    const int64_t values = (int64_t)d.frames * d.height * d.width * 3;
    float *control = make_floats(values, 12), *text = make_floats(2 * (int64_t)t->text_tokens * t->text_channels, 13);
    float *dino = make_floats(TOKENS * (int64_t)t->dino_channels, 14);
    float *vggt = make_floats(TOKENS * (int64_t)t->vggt_channels, 15), *references = make_floats(TOKENS * width, 16);
    float* video = make_floats(values, 17);
    stage_output* out = begin_stage(run, "references");
    CHECK_OK(ctx, gsf_nn_project_references(ctx, t, TOKENS, dino, vggt, references));
    add_floats(out, references, TOKENS * width);
    d.control = control;
    d.text = text;
    d.references = references;
    d.reference_tokens = TOKENS;
    d.steps = 1;
    out = begin_stage(run, "sampling");
    CHECK_OK(ctx, gsf_nn_sample(ctx, t, &m->vae, &m->schedule, &d, video, NULL));
    add_floats(out, video, values);
    const double timestep = 500.0;
    gsf_nn_transformer_desc in;
    memset(&in, 0, sizeof in);
    in.batch = in.reference_batch = 1;
    in.frames = (t->sample_frames - 1) / t->temporal_ratio + 1;
    in.height = t->sample_height;
    in.width = t->sample_width;
    in.hidden = control; // of many more values
    in.text = text;
    in.timesteps = &timestep;
    in.references = references;
    in.reference_tokens = TOKENS;
    out = begin_stage(run, "int8");
    const int64_t latents = (int64_t)in.frames * in.height * in.width;
    CHECK(latents * t->in_channels <= values && latents * t->out_channels <= values);
    CHECK_OK(ctx, gsf_nn_quantize_transformer(ctx, &m->transformer, NULL));
    CHECK_OK(ctx, gsf_nn_run_transformer(ctx, t, &in, video));
    add_floats(out, video, latents * t->out_channels);
    free(control);
    free(text);
    free(dino);
    free(vggt);
    free(references);
    free(video);
}

static void run_tiles(gsf_context* ctx, run_output* run, const gsf_nn_vae* vae) { // blended across their edges
    const int64_t h = 8, w = 6; // rows of two tiles
    float* latents = make_floats(vae->latent_channels * 3 * h * w, 18);
    gsf_nn_vae_desc d;
    gsf_nn_vae_info info;
    memset(&d, 0, sizeof d);
    d.tiled = 1;
    stage_output* out = begin_stage(run, "tiles");
    if (CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, &d, 3, h, w, &info))) {
        const int64_t count = vae->out_channels * info.frames * info.height * info.width;
        float* video = make_floats(count, 19);
        CHECK_OK(ctx, gsf_nn_decode_vae(ctx, vae, &d, latents, 3, h, w, video));
        add_floats(out, video, count);
        free(video);
    }
    free(latents);
}

static void run_all(gsf_context* ctx, run_output* run) {
    model m;
    run_linear(ctx, run);
    run_attention(ctx, run);
    run_norms(ctx, run);
    run_convolution(ctx, run);
    if (open_model(ctx, &m)) {
        run_tiles(ctx, run, &m.vae);
        run_sampling(ctx, run, &m);
    }
    close_model(ctx, &m);
}

int main(void) {
    compare_runs(run_all);
    return test_report();
}
