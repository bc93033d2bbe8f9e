// encoders_vggt.h - VGGT's aggregator against the float64 run of the official code.
#ifndef ENCODERS_VGGT_H
#define ENCODERS_VGGT_H

#include "encoders_golden.h"

static const double vggt_bar = 4e-5; // of values about 1; 3.3e-6 is reached

typedef struct vggt_case {
    test_tensors expected;
    int index, seen, images;
} vggt_case;

// Frame and global block of the first pair are the two halves of out_first.
static void see_vggt_tap(void* user, const char* name, int32_t image, const float* data, int64_t rows, int64_t columns) {
    vggt_case* c = (vggt_case*)user;
    const int half = strcmp(name, "frame0") == 0 ? 1 : strcmp(name, "global0") == 0 ? 2 : 0;
    char whole[96];
    snprintf(whole, sizeof whole, "case%d.%s", c->index, half ? "out_first" : name);
    test_tensor t = test_find_tensor(&c->expected, whole);
    if (!t.v) return;
    const int64_t ld = half ? 2 * columns : columns;
    if (CHECK(t.count == (size_t)(c->images * rows * ld)))
        check_rows(whole, data, rows, columns, columns, t.v + image * rows * ld + (half == 2 ? columns : 0), ld, vggt_bar);
    c->seen++;
    test_free_tensor(&t);
}

static void check_vggt(void) {
    gsf_context ctx;
    gsf_nn_vggt net;
    vggt_case c;
    test_context_init(&ctx);
    if (!CHECK_OK(&ctx, gsf_nn_make_vggt(&ctx, test_golden("encoders/vggt"), &net))) return;
    c.expected = test_open_tensors(test_golden("encoders/vggt_expected.safetensors"));
    for (c.index = 0;; c.index++) {
        char name[64];
        snprintf(name, sizeof name, "case%d.images", c.index);
        test_tensor there = test_find_tensor(&c.expected, name);
        if (!there.v) break;
        test_free_tensor(&there);
        gsf_nn_encoder_input in;
        float* pixels = golden_images(&c.expected, name, &in);
        const int64_t tokens = (int64_t)(in.height / net.patch) * (in.width / net.patch), all = tokens + net.special;
        const int64_t d = 2 * (int64_t)net.width;
        float* out = (float*)malloc((size_t)(in.images * all * d) * sizeof(float));
        in.tap_fn = see_vggt_tap;
        in.tap_user = &c;
        c.seen = 0;
        c.images = in.images;
        CHECK_OK(&ctx, gsf_nn_vggt_encode(&ctx, &net, &in, out));
        CHECK(c.seen >= in.images);
        snprintf(name, sizeof name, "case%d.out_last", c.index);
        test_tensor last = test_get_tensor(&c.expected, name);
        CHECK(last.count == (size_t)(in.images * all * d));
        for (int64_t i = 0; i < in.images; i++)
            check_rows("patches", out + i * tokens * d, tokens, d, d, last.v + (i * all + net.special) * d, d, vggt_bar);
        in.all_tokens = 1;
        in.tap_fn = NULL;
        CHECK_OK(&ctx, gsf_nn_vggt_encode(&ctx, &net, &in, out));
        check_rows("all tokens", out, in.images * all, d, d, last.v, d, vggt_bar);
        test_free_tensor(&last);
        snprintf(name, sizeof name, "case%d.patch_start_idx", c.index);
        test_tensor start = test_get_tensor(&c.expected, name);
        CHECK(start.v[0] == (double)net.special);
        test_free_tensor(&start);
        free(out);
        free(pixels);
    }
    CHECK(c.index > 0);
    test_close_tensors(&c.expected);
    gsf_nn_destroy_vggt(&ctx, &net);
}

#endif
