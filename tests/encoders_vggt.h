// encoders_vggt.h - VGGT's aggregator against a float64 run of VGGT's own code.
#ifndef ENCODERS_VGGT_H
#define ENCODERS_VGGT_H

#include "encoders_golden.h"

static const double vggt_bar = 4e-5; // for values of about 1; measured error 3.3e-6

// The outputs of the first frame block and the first global block are the two halves of out_first.
static void see_vggt_tap(void* encoder, const char* name, int32_t image, const float* data, int64_t rows,
                         int64_t columns) {
    golden_encoder* e = (golden_encoder*)encoder;
    const int half = strcmp(name, "frame0") == 0 ? 1 : strcmp(name, "global0") == 0 ? 2 : 0;
    test_tensor t = golden_case(e, half ? "out_first" : name);
    if (!t.v) return;
    const int64_t ld = half ? 2 * columns : columns;
    if (CHECK(t.count == (size_t)(e->images * rows * ld)))
        check_rows(t.name, data, rows, columns, columns, t.v + image * rows * ld + (half == 2 ? columns : 0), ld, vggt_bar);
    e->seen++;
    test_free_tensor(&t);
}

static gsf_result encode_vggt(gsf_context* ctx, const void* net, const gsf_nn_encoder_desc* in, float* out) {
    return gsf_nn_encode_vggt(ctx, (const gsf_nn_vggt*)net, in, out);
}

static void check_vggt(void) {
    gsf_context ctx;
    gsf_nn_vggt net;
    test_context_init(&ctx);
    if (!CHECK_OK(&ctx, gsf_nn_load_vggt(&ctx, test_golden("encoders/vggt"), &net))) return;
    golden_encoder e = {.net = &net, .input = "images", .output = "out_last",
                        .patch = net.patch, .special = net.special, .width = 2 * (int64_t)net.width,
                        .bar = vggt_bar, .encode = encode_vggt, .see_tap = see_vggt_tap};
    check_encoder(&ctx, &e, "encoders/vggt_expected.safetensors");
    while (e.index-- > 0) {
        test_tensor start = golden_case(&e, "patch_start_idx");
        CHECK(start.v && start.v[0] == (double)net.special);
        test_free_tensor(&start);
    }
    test_close_tensors(&e.expected);
    gsf_nn_destroy_vggt(&ctx, &net);
}

#endif
