// encoders_golden.h - what the parts of golden_encoders share.
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
            if (!(error <= worst)) worst = error; // a NaN wins
        }
    if (getenv("GSF_TEST_VERBOSE")) printf("%-40s %.3g (bar %.3g)\n", what, worst, bar);
    if (!test_check(worst <= bar, what, __FILE__, __LINE__))
        fprintf(stderr, "    largest error %.3g, allowed %.3g\n", worst, bar);
}

// The images of one case as an encoder takes them; a leading dimension of 1 is passed over.
static inline float* golden_images(const test_tensors* file, const char* name, gsf_nn_encoder_input* in) { // to be freed
    test_tensor t = test_get_tensor(file, name);
    float* pixels = test_tensor_floats(&t);
    const size_t* dim = t.dim + (t.rank - 4);
    memset(in, 0, sizeof *in);
    in->pixels = pixels;
    in->images = (int32_t)dim[0];
    in->height = (int32_t)dim[2];
    in->width = (int32_t)dim[3];
    test_free_tensor(&t);
    return pixels;
}

#endif
