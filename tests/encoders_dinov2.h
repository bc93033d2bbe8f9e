// encoders_dinov2.h - DINOv2 with registers against the float64 run of transformers.
#ifndef ENCODERS_DINOV2_H
#define ENCODERS_DINOV2_H

#include "encoders_golden.h"

static const double dinov2_bar = 2e-5;          // for values of about 1; measured error 1.5e-6
static const double dinov2_positions_bar = 5e-6; // measured error 5e-7

static void see_dinov2_tap(void* encoder, const char* name, int32_t image, const float* data, int64_t rows,
                           int64_t columns) {
    golden_encoder* e = (golden_encoder*)encoder;
    const int positions = strcmp(name, "positions") == 0;
    test_tensor t = golden_case(e, positions ? "pos_embed_interp" : name);
    if (!t.v) return;
    const size_t at = (size_t)image * (size_t)(rows * columns);
    if (CHECK(at + (size_t)(rows * columns) <= t.count))
        check_rows(t.name, data, rows, columns, columns, t.v + at, columns, positions ? dinov2_positions_bar : dinov2_bar);
    e->seen++;
    test_free_tensor(&t);
}

static gsf_result encode_dinov2(gsf_context* ctx, const void* net, const gsf_nn_encoder_desc* in, float* out) {
    return gsf_nn_encode_dinov2(ctx, (const gsf_nn_dinov2*)net, in, out);
}

static void check_dinov2(void) {
    gsf_context ctx;
    gsf_nn_dinov2 net;
    test_context_init(&ctx);
    if (!CHECK_OK(&ctx, gsf_nn_load_dinov2(&ctx, test_golden("encoders/dinov2_reg"), &net))) return;
    golden_encoder e = {.net = &net, .input = "pixel_values", .output = "last_hidden_state",
                        .patch = net.patch, .special = net.special, .width = net.width,
                        .bar = dinov2_bar, .encode = encode_dinov2, .see_tap = see_dinov2_tap};
    check_encoder(&ctx, &e, "encoders/dinov2_reg_expected.safetensors");
    test_close_tensors(&e.expected);
    gsf_nn_destroy_dinov2(&ctx, &net);
}

#endif
