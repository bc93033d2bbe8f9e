// restorer_transformer.h - the transformer and all its intermediates against a float64 run of the GSFixer release.
#ifndef RESTORER_TRANSFORMER_H
#define RESTORER_TRANSFORMER_H

#include "restorer_golden.h"

static const double transformer_bar = 1e-5;    // relative L2 against float64
static const double intermediate_bar = 1e-5;   // against the float32 run
static const double int8_bar = 5e-2;           // with 8-bit linear layers in the blocks
// against float64, weights rounded to bf16; twice that of the release's bf16 run
static const double bf16_bar = 2.0 * 8.8e-3;

typedef struct transformer_case {
    gsf_context ctx;
    gsf_nn_transformer net;
    test_tensors inputs, f32, f64, taps;
    unsigned char* seen; // per tensor of the intermediates
    gsf_nn_weights names;
    int32_t batch;
} transformer_case;

static void see_tap(void* user, const char* name, int32_t row, const float* data, int64_t rows, int64_t columns) {
    transformer_case* c = (transformer_case*)user;
    char whole[128];
    // Intermediates have every row of the batch, or the row in their name's tag; a single row without a tag (block1.*)
    // is the last.
    for (int tagged = 0; tagged < 2; tagged++) {
        if (tagged) snprintf(whole, sizeof whole, "%s[b=%d]", name, (int)row);
        else snprintf(whole, sizeof whole, "%s", name);
        test_tensor t = test_find_tensor(&c->taps, whole);
        if (!t.v) continue;
        const size_t count = (size_t)(rows * columns);
        const int single = tagged || (t.count == count && row == c->batch - 1);
        const size_t at = single ? 0 : (size_t)row * count;
        if (single || t.count > count) check_rel_l2(whole, data, t.v + at, count, intermediate_bar);
        for (size_t i = 0; i < c->names.tensor_count; i++)
            if (strcmp(c->names.tensors[i].name, whole) == 0 && at + count <= t.count) c->seen[i] = 1;
        test_free_tensor(&t);
    }
}

// The projectors' tensors are tagged with their image: "projector_dino[image 3]".
static void check_projectors(transformer_case* c, const float* dino, const float* vggt, int64_t tokens, int64_t width) {
    const gsf_nn_transformer* net = &c->net;
    float* out = (float*)malloc((size_t)(tokens * width) * sizeof(float));
    for (size_t i = 0; i < c->names.tensor_count; i++) {
        const char* name = c->names.tensors[i].name;
        const int kind = strncmp(name, "projector_dino[", 15) == 0 ? 1 : strncmp(name, "projector_vggt[", 15) == 0 ? 2 : 0;
        const char* image = strstr(name, "image ");
        if (!kind || !image) continue;
        const int64_t at = atoi(image + 6) * tokens;
        CHECK_OK(&c->ctx, gsf_nn_project_references(&c->ctx, &c->net, tokens,
                                                    kind == 1 ? dino + at * net->dino_channels : NULL,
                                                    kind == 2 ? vggt + at * net->vggt_channels : NULL, out));
        test_tensor t = test_get_tensor(&c->taps, name);
        CHECK(t.count == (size_t)(tokens * width));
        check_rel_l2(name, out, t.v, t.count, intermediate_bar);
        test_free_tensor(&t);
        c->seen[i] = 1;
    }
    free(out);
}

// bar: the tolerance of the float32 path, or that of other weights (net).
static void check_output(transformer_case* c, const gsf_nn_transformer* net, const gsf_nn_transformer_desc* in,
                         const char* name, double bar) {
    test_tensor t = test_get_tensor(&c->f64, name);
    float* out = (float*)malloc(t.count * sizeof(float));
    CHECK_OK(&c->ctx, gsf_nn_run_transformer(&c->ctx, net, in, out));
    check_rel_l2(name, out, t.v, t.count, bar);
    free(out);
    test_free_tensor(&t);
}

// The same weights rounded to bf16, in one file.
static gsf_nn_transformer open_rounded(gsf_context* ctx, const char* folder) {
    gsf_nn_weights weights;
    gsf_nn_transformer net;
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, folder, "diffusion_pytorch_model", &weights));
    gsf_nn_tensor* rounded = (gsf_nn_tensor*)malloc(weights.tensor_count * sizeof(gsf_nn_tensor));
    for (size_t i = 0; i < weights.tensor_count; i++) {
        rounded[i] = weights.tensors[i];
        float* wide = (float*)malloc((size_t)rounded[i].count * sizeof(float));
        uint16_t* narrow = (uint16_t*)malloc((size_t)rounded[i].count * sizeof(uint16_t));
        gsf_nn_convert_tensor(&weights.tensors[i], 0, rounded[i].count, wide);
        for (int64_t j = 0; j < rounded[i].count; j++) narrow[j] = gsf__float_to_bf16(wide[j]);
        rounded[i].dtype = GSF_NN_BF16;
        rounded[i].data = narrow;
        free(wide);
    }
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("diffusion_pytorch_model.safetensors"), rounded,
                                          weights.tensor_count));
    for (size_t i = 0; i < weights.tensor_count; i++) free((void*)(uintptr_t)rounded[i].data);
    free(rounded);
    gsf_nn_destroy_weights(ctx, &weights);
    char path[1200];
    snprintf(path, sizeof path, "%s/config.json", folder);
    size_t size;
    char* config = test_read_file(path, &size);
    CHECK_OK(ctx, gsf_write_file(ctx, test_scratch("config.json"), config, size));
    free(config);
    CHECK_OK(ctx, gsf_nn_load_transformer(ctx, test_scratch("."), &net));
    return net;
}

static void check_transformer(void) {
    transformer_case c;
    memset(&c, 0, sizeof c);
    test_context_init(&c.ctx);
    char folder[1100];
    snprintf(folder, sizeof folder, "%s", test_golden("restorer/model/transformer"));
    if (!CHECK_OK(&c.ctx, gsf_nn_load_transformer(&c.ctx, folder, &c.net))) return;
    c.inputs = test_open_tensors(test_golden("restorer/transformer/inputs.safetensors"));
    c.f32 = test_open_tensors(test_golden("restorer/transformer/expected_f32.safetensors"));
    c.f64 = test_open_tensors(test_golden("restorer/transformer/expected_f64.safetensors"));
    c.taps = test_open_tensors(test_golden("restorer/transformer/intermediates_f32.safetensors"));
    CHECK_OK(&c.ctx, gsf_nn_load_weights(&c.ctx, c.taps.path, NULL, &c.names));
    c.seen = (unsigned char*)calloc(c.names.tensor_count, 1);
    const gsf_nn_transformer* net = &c.net;
    const int64_t width = (int64_t)net->heads * net->head_dim;

    test_tensor hidden, text, dino_shape, hidden_b, text_b;
    float* hidden_v = golden_floats(&c.inputs, "hidden_states", &hidden);
    float* text_v = golden_floats(&c.inputs, "encoder_hidden_states", &text);
    float* dino = golden_floats(&c.inputs, "dino_latents", &dino_shape);
    float* vggt = golden_floats(&c.inputs, "vggt_latents", NULL);
    const int32_t batch = c.batch = (int32_t)hidden.dim[0];
    const int64_t tokens = (int64_t)dino_shape.dim[1], all = (int64_t)dino_shape.dim[0] * tokens;
    float* references = (float*)malloc((size_t)(all * width) * sizeof(float));
    CHECK_OK(&c.ctx, gsf_nn_project_references(&c.ctx, &c.net, all, dino, vggt, references));
    check_projectors(&c, dino, vggt, tokens, width);

    double* steps = (double*)calloc((size_t)batch, sizeof(double));
    gsf_nn_transformer_desc in;
    memset(&in, 0, sizeof in);
    in.batch = batch;
    in.frames = (int32_t)hidden.dim[1];
    in.height = (int32_t)hidden.dim[3];
    in.width = (int32_t)hidden.dim[4];
    in.hidden = hidden_v;
    in.text = text_v;
    in.timesteps = steps;
    in.references = references;
    in.reference_tokens = all / batch;
    in.reference_batch = batch;
    gsf_nn_transformer rounded = open_rounded(&c.ctx, folder);
    static const int times[] = {999, 479};
    for (int i = 0; i < 2; i++) {
        char name[32];
        snprintf(name, sizeof name, "out_t%d", times[i]);
        for (int b = 0; b < batch; b++) steps[b] = times[i];
        const gsf__nn_tap tap = {see_tap, &c};
        in._tap = times[i] == 999 ? &tap : NULL;
        check_output(&c, &c.net, &in, name, transformer_bar);
        in._tap = NULL;
        check_output(&c, &rounded, &in, name, bf16_bar);
        rounded.bf16 = 1; // also with bf16 products where the processor supports them
        check_output(&c, &rounded, &in, name, bf16_bar);
        rounded.bf16 = 0;
    }
    size_t bytes = 0;
    CHECK_OK(&c.ctx, gsf_nn_quantize_transformer(&c.ctx, &rounded, &bytes));
    CHECK(bytes > (size_t)(16 * width * width * rounded.layers) && bytes < (size_t)(17 * width * width * rounded.layers));
    check_output(&c, &rounded, &in, "out_t479", int8_bar);
    for (size_t i = 0; i < c.names.tensor_count; i++)
        if (!CHECK(c.seen[i])) fprintf(stderr, "    no intermediate is called %s\n", c.names.tensors[i].name);

    steps[0] = 479.0; // case C: different time steps, no rotary embedding
    for (int b = 1; b < batch; b++) steps[b] = 3.0;
    in.no_rotary = 1;
    check_output(&c, &c.net, &in, "caseC_out", transformer_bar);
    in.no_rotary = 0;

    float* hidden_b_v = golden_floats(&c.inputs, "caseB.hidden_states", &hidden_b); // another frame count
    float* text_b_v = golden_floats(&c.inputs, "caseB.encoder_hidden_states", &text_b);
    in.batch = in.reference_batch = (int32_t)hidden_b.dim[0];
    in.frames = (int32_t)hidden_b.dim[1];
    in.hidden = hidden_b_v;
    in.text = text_b_v;
    steps[0] = 333.0;
    check_output(&c, &c.net, &in, "caseB_out", transformer_bar);

    free(hidden_v);
    free(text_v);
    free(dino);
    free(vggt);
    free(references);
    free(hidden_b_v);
    free(text_b_v);
    free(steps);
    free(c.seen);
    gsf_nn_destroy_weights(&c.ctx, &c.names);
    test_close_tensors(&c.inputs);
    test_close_tensors(&c.f32);
    test_close_tensors(&c.f64);
    test_close_tensors(&c.taps);
    gsf_nn_destroy_transformer(&c.ctx, &rounded);
    gsf_nn_destroy_transformer(&c.ctx, &c.net);
}

#endif
