// encoders_dinov2.h - DINOv2 with registers against the float64 run of transformers.
#ifndef ENCODERS_DINOV2_H
#define ENCODERS_DINOV2_H

#include "encoders_golden.h"

static const double dinov2_bar = 2e-5;          // of values about 1; 1.5e-6 is reached
static const double dinov2_positions_bar = 5e-6; // 5e-7

typedef struct dinov2_case {
    test_tensors expected;
    int index, seen;
} dinov2_case;

static void see_dinov2_tap(void* user, const char* name, int32_t image, const float* data, int64_t rows, int64_t columns) {
    dinov2_case* c = (dinov2_case*)user;
    const int positions = strcmp(name, "positions") == 0;
    char whole[96];
    snprintf(whole, sizeof whole, "case%d.%s", c->index, positions ? "pos_embed_interp" : name);
    test_tensor t = test_find_tensor(&c->expected, whole);
    if (!t.v) return;
    const size_t at = (size_t)image * (size_t)(rows * columns);
    if (CHECK(at + (size_t)(rows * columns) <= t.count))
        check_rows(whole, data, rows, columns, columns, t.v + at, columns, positions ? dinov2_positions_bar : dinov2_bar);
    c->seen++;
    test_free_tensor(&t);
}

static void check_dinov2(void) {
    gsf_context ctx;
    gsf_nn_dinov2 net;
    dinov2_case c;
    test_context_init(&ctx);
    if (!CHECK_OK(&ctx, gsf_nn_make_dinov2(&ctx, test_golden("encoders/dinov2_reg"), &net))) return;
    c.expected = test_open_tensors(test_golden("encoders/dinov2_reg_expected.safetensors"));
    for (c.index = 0;; c.index++) {
        char name[64];
        snprintf(name, sizeof name, "case%d.pixel_values", c.index);
        test_tensor there = test_find_tensor(&c.expected, name);
        if (!there.v) break;
        test_free_tensor(&there);
        gsf_nn_encoder_input in;
        float* pixels = golden_images(&c.expected, name, &in);
        const int64_t tokens = (int64_t)(in.height / net.patch) * (in.width / net.patch), all = tokens + net.special;
        float* out = (float*)malloc((size_t)(in.images * all * net.width) * sizeof(float));
        in.tap_fn = see_dinov2_tap;
        in.tap_user = &c;
        c.seen = 0;
        CHECK_OK(&ctx, gsf_nn_dinov2_encode(&ctx, &net, &in, out));
        CHECK(c.seen >= in.images);
        snprintf(name, sizeof name, "case%d.last_hidden_state", c.index);
        test_tensor last = test_get_tensor(&c.expected, name);
        CHECK(last.count == (size_t)(in.images * all * net.width));
        for (int64_t i = 0; i < in.images; i++)
            check_rows("patches", out + i * tokens * net.width, tokens, net.width, net.width,
                       last.v + (i * all + net.special) * net.width, net.width, dinov2_bar);
        in.all_tokens = 1;
        in.tap_fn = NULL;
        CHECK_OK(&ctx, gsf_nn_dinov2_encode(&ctx, &net, &in, out));
        check_rows("all tokens", out, in.images * all, net.width, net.width, last.v, net.width, dinov2_bar);
        test_free_tensor(&last);
        free(out);
        free(pixels);
    }
    CHECK(c.index > 0);
    test_close_tensors(&c.expected);
    gsf_nn_destroy_dinov2(&ctx, &net);
}

#endif
