// restorer_t5.h - the text encoder and its intermediates against runs of transformers.
#ifndef RESTORER_T5_H
#define RESTORER_T5_H

#include "restorer_golden.h"

// relative L2 against float64: ten times that of transformers' float32 run
static const double t5_bar = 10.0 * 3.211e-7;
static const double t5_long_bar = 10.0 * 5.275e-7; // for 226 tokens, against the float32 run
static const double t5_bf16_bar = 2.0 * 7.022e-3; // against the run that also has bf16 activations

typedef struct t5_case {
    gsf_context ctx;
    gsf_nn_t5 net;
    test_tensors inputs, f32, f64, taps;
    size_t seen; // number of intermediates compared
} t5_case;

// Intermediates cover prompts `first` to `last` - 1: "block0.out[rows 1:3]"; the last block is "last_block".
static void see_t5(void* user, const char* name, int32_t row, const float* data, int64_t rows, int64_t columns) {
    t5_case* c = (t5_case*)user;
    char last_block[32], whole[96];
    const size_t count = (size_t)(rows * columns);
    snprintf(last_block, sizeof last_block, "block%d.", (int)c->net.layers - 1);
    for (int renamed = 0; renamed < 2; renamed++) {
        const int is_last = strncmp(name, last_block, strlen(last_block)) == 0;
        if (renamed && !is_last) continue;
        for (int first = 0; first <= row; first++)
            for (int last = row + 1; last < 16; last++) {
                snprintf(whole, sizeof whole, "%s%s[rows %d:%d]", renamed ? "last_block." : "",
                         renamed ? name + strlen(last_block) : name, first, last);
                test_tensor t = test_find_tensor(&c->taps, whole);
                if (!t.v) continue;
                if (CHECK(t.count == count * (size_t)(last - first)))
                    check_rel_l2(whole, data, t.v + (size_t)(row - first) * count, count, t5_bar);
                test_free_tensor(&t);
                c->seen++;
            }
    }
}

static int32_t* t5_ids(const t5_case* c, const char* name, gsf_nn_t5_desc* in) { // to be freed
    test_tensor t = test_get_tensor(&c->inputs, name);
    int32_t* ids = (int32_t*)malloc(t.count * sizeof *ids);
    for (size_t i = 0; i < t.count; i++) ids[i] = (int32_t)t.v[i];
    memset(in, 0, sizeof *in);
    in->ids = ids;
    in->batch = (int32_t)t.dim[0];
    in->tokens = (int32_t)t.dim[1];
    test_free_tensor(&t);
    return ids;
}

static void check_t5_output(t5_case* c, const gsf_nn_t5* net, const gsf_nn_t5_desc* in, const test_tensors* file,
                            const char* name, double bar) {
    test_tensor t = test_get_tensor(file, name);
    float* out = (float*)malloc(t.count * sizeof(float));
    CHECK(t.count == (size_t)in->batch * (size_t)in->tokens * (size_t)net->width);
    if (CHECK_OK(&c->ctx, gsf_nn_encode_t5(&c->ctx, net, in, out))) check_rel_l2(name, out, t.v, t.count, bar);
    free(out);
    test_free_tensor(&t);
}

// Writes every tensor as `dtype` to one file: f32 holds the same values as bf16, f16 nearly.
static gsf_nn_t5 open_t5_as(gsf_context* ctx, const char* folder, gsf_nn_dtype dtype) {
    gsf_nn_weights weights;
    gsf_nn_t5 net;
    char path[1200];
    size_t size;
    memset(&net, 0, sizeof net);
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, folder, "model", &weights))) return net;
    gsf_nn_tensor* changed = (gsf_nn_tensor*)malloc(weights.tensor_count * sizeof *changed);
    for (size_t i = 0; i < weights.tensor_count; i++) {
        gsf_nn_tensor* t = &changed[i];
        *t = weights.tensors[i];
        float* wide = (float*)malloc((size_t)t->count * sizeof(float));
        gsf_nn_convert_tensor(&weights.tensors[i], 0, t->count, wide);
        for (int64_t k = 0; dtype == GSF_NN_F16 && k < t->count; k++) {
            const uint16_t half = gsf__float_to_half(wide[k]);
            memcpy((char*)wide + 2 * k, &half, sizeof half);
        }
        t->dtype = dtype;
        t->data = wide;
    }
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("model.safetensors"), changed, weights.tensor_count));
    for (size_t i = 0; i < weights.tensor_count; i++) free((void*)(uintptr_t)changed[i].data);
    free(changed);
    gsf_nn_destroy_weights(ctx, &weights);
    snprintf(path, sizeof path, "%s/config.json", folder);
    char* config = test_read_file(path, &size);
    CHECK_OK(ctx, gsf_write_file(ctx, test_scratch("config.json"), config, size));
    free(config);
    CHECK_OK(ctx, gsf_nn_load_t5(ctx, test_scratch("."), &net));
    return net;
}

static void check_t5_positions(const t5_case* c) {
    // key - query = 0, 1, 2, ... and 0, -1, -2, ...
    test_tensor buckets = test_get_tensor(&c->f32, "bucket_of_distance");
    const int64_t n = (int64_t)buckets.dim[1];
    for (int64_t i = 0; i < n; i++) {
        CHECK(gsf__t5_bucket(&c->net, i) == (int32_t)buckets.v[i]);
        CHECK(gsf__t5_bucket(&c->net, -i) == (int32_t)buckets.v[n + i]);
    }
    test_free_tensor(&buckets);
    test_tensor expected = test_get_tensor(&c->f32, "position_bias40");
    const int64_t tokens = (int64_t)expected.dim[3];
    const gsf__t5_nets* nets = (const gsf__t5_nets*)c->net.nets;
    float* bias = (float*)malloc(expected.count * sizeof(float));
    float* scratch = (float*)malloc((size_t)(2 * tokens + c->net.buckets * c->net.heads) * sizeof(float));
    if (CHECK(expected.count == (size_t)(c->net.heads * tokens * tokens))) {
        gsf__t5_fill_bias(&c->net, nets->positions, tokens, scratch, bias);
        test_compare_floats("position_bias40", bias, expected.v, expected.count, 0.0);
    }
    free(bias);
    free(scratch);
    test_free_tensor(&expected);
}

static void check_t5(void) {
    t5_case c;
    gsf_nn_t5_desc in, in226;
    gsf_nn_weights names;
    memset(&c, 0, sizeof c);
    test_context_init(&c.ctx);
    const char* folder = test_golden("restorer/model/text_encoder");
    if (!CHECK_OK(&c.ctx, gsf_nn_load_t5(&c.ctx, folder, &c.net))) return;
    c.inputs = test_open_tensors(test_golden("restorer/t5/inputs.safetensors"));
    c.f32 = test_open_tensors(test_golden("restorer/t5/expected_f32.safetensors"));
    c.f64 = test_open_tensors(test_golden("restorer/t5/expected_f64.safetensors"));
    c.taps = test_open_tensors(test_golden("restorer/t5/intermediates_f32.safetensors"));
    int32_t *ids = t5_ids(&c, "ids", &in), *ids226 = t5_ids(&c, "ids226", &in226);
    check_t5_positions(&c);
    const gsf__nn_tap tap = {see_t5, &c};
    in._tap = &tap;
    check_t5_output(&c, &c.net, &in, &c.f64, "out", t5_bar);
    in._tap = NULL;
    if (CHECK_OK(&c.ctx, gsf_nn_load_weights(&c.ctx, c.taps.path, NULL, &names))) {
        size_t rows = 0; // a tensor covers as many prompts as its first dimension
        for (size_t i = 0; i < names.tensor_count; i++) rows += (size_t)names.tensors[i].shape[0];
        CHECK(c.seen == rows && rows > 0);
        gsf_nn_destroy_weights(&c.ctx, &names);
    }
    check_t5_output(&c, &c.net, &in, &c.f32, "out_bf16", t5_bf16_bar);
    check_t5_output(&c, &c.net, &in226, &c.f32, "out226", t5_long_bar);
    static const gsf_nn_dtype dtypes[] = {GSF_NN_F32, GSF_NN_F16};
    for (size_t i = 0; i < GSF__COUNT(dtypes); i++) { // f16 rounds the smallest values
        gsf_nn_t5 net = open_t5_as(&c.ctx, folder, dtypes[i]);
        if (net.nets) check_t5_output(&c, &net, &in, &c.f64, "out", i ? 1e-5 : t5_bar);
        gsf_nn_destroy_t5(&c.ctx, &net);
    }
    free(ids);
    free(ids226);
    test_close_tensors(&c.inputs);
    test_close_tensors(&c.f32);
    test_close_tensors(&c.f64);
    test_close_tensors(&c.taps);
    gsf_nn_destroy_t5(&c.ctx, &c.net);
}

#endif
