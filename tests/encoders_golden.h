// encoders_golden.h - shared by the parts of golden_encoders.
#ifndef ENCODERS_GOLDEN_H
#define ENCODERS_GOLDEN_H

#include "test.h"

// |actual - expected| <= bar for `rows` rows of `columns` values, `ld` and `expected_ld` values apart.
static inline void check_rows(const char* what, const float* actual, int64_t rows, int64_t columns, int64_t ld,
                              const double* expected, int64_t expected_ld, double bar) {
    double worst = 0.0;
    for (int64_t r = 0; r < rows; r++)
        for (int64_t i = 0; i < columns; i++) {
            const double error = fabs((double)actual[r * ld + i] - expected[r * expected_ld + i]);
            if (!(error <= worst)) worst = error; // a NaN is kept
        }
    if (getenv("GSF_TEST_VERBOSE")) printf("%-40s %.3g (bar %.3g)\n", what, worst, bar);
    if (!test_check(worst <= bar, what, __FILE__, __LINE__))
        fprintf(stderr, "    largest error %.3g, allowed %.3g\n", worst, bar);
}

// Images in the encoder's layout; a leading dimension of 1 is dropped.
static inline float* golden_images(const test_tensor* t, gsf_nn_encoder_desc* in) { // freed by the caller
    float* pixels = test_tensor_floats(t);
    const size_t* dim = t->dim + (t->rank - 4);
    memset(in, 0, sizeof *in);
    in->pixels = pixels;
    in->images = (int32_t)dim[0];
    in->height = (int32_t)dim[2];
    in->width = (int32_t)dim[3];
    return pixels;
}

// An image encoder and the names of its test cases: caseN.INPUT must give caseN.OUTPUT.
typedef struct golden_encoder {
    const void* net;
    const char *input, *output;
    int64_t patch, special, width; // width: channels of a token
    double bar;
    gsf_result (*encode)(gsf_context* ctx, const void* net, const gsf_nn_encoder_desc* in, float* out);
    void (*see_tap)(void* encoder, const char* name, int32_t image, const float* data, int64_t rows, int64_t columns);
    test_tensors expected;
    int index, images, seen; // of the current case: its number, images, intermediates compared
} golden_encoder;

static inline test_tensor golden_case(const golden_encoder* e, const char* name) { // .v NULL when absent
    char whole[96];
    snprintf(whole, sizeof whole, "case%d.%s", e->index, name);
    return test_find_tensor(&e->expected, whole);
}

static inline void check_encoder_case(gsf_context* ctx, golden_encoder* e, gsf_nn_encoder_desc in) {
    const int64_t d = e->width, tokens = in.height / e->patch * (in.width / e->patch), all = tokens + e->special;
    const size_t count = (size_t)(in.images * all * d);
    float* out = (float*)malloc(count * sizeof(float));
    test_tensor last = golden_case(e, e->output);
    if (CHECK(last.count == count)) {
        const gsf__nn_tap tap = {e->see_tap, e};
        in._tap = &tap;
        e->images = in.images;
        e->seen = 0;
        CHECK_OK(ctx, e->encode(ctx, e->net, &in, out));
        CHECK(e->seen >= in.images);
        for (int64_t i = 0; i < in.images; i++)
            check_rows("patches", out + i * tokens * d, tokens, d, d, last.v + (i * all + e->special) * d, d, e->bar);
        in.all_tokens = 1;
        in._tap = NULL;
        CHECK_OK(ctx, e->encode(ctx, e->net, &in, out));
        check_rows("all tokens", out, in.images * all, d, d, last.v, d, e->bar);
    }
    test_free_tensor(&last);
    free(out);
}

// Runs all cases of a file; leaves the file open and the number of cases in e->index.
static inline void check_encoder(gsf_context* ctx, golden_encoder* e, const char* file) {
    e->expected = test_open_tensors(test_golden(file));
    for (e->index = 0;; e->index++) {
        test_tensor input = golden_case(e, e->input);
        if (!input.v) break;
        gsf_nn_encoder_desc in;
        float* pixels = golden_images(&input, &in);
        check_encoder_case(ctx, e, in);
        free(pixels);
        test_free_tensor(&input);
    }
    CHECK(e->index > 0);
}

#endif
