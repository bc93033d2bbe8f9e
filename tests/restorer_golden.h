// restorer_golden.h - shared by the parts of golden_restorer.
#ifndef RESTORER_GOLDEN_H
#define RESTORER_GOLDEN_H

#include "test.h"

// |actual - expected| / |expected| <= bar, over `count` values.
static inline void check_rel_l2(const char* what, const float* actual, const double* expected, size_t count, double bar) {
    double error = 0.0, norm = 0.0;
    for (size_t i = 0; i < count; i++) {
        const double e = (double)actual[i] - expected[i];
        error += e * e;
        norm += expected[i] * expected[i];
    }
    const double rel = sqrt(error / (norm > 0.0 ? norm : 1.0));
    if (getenv("GSF_TEST_VERBOSE")) printf("%-40s %.3g (bar %.3g)\n", what, rel, bar);
    if (!test_check(rel <= bar, what, __FILE__, __LINE__))
        fprintf(stderr, "    relative L2 error %.3g, allowed %.3g\n", rel, bar);
}

static inline double* golden_doubles(const test_tensors* file, const char* name, size_t* count) { // to be freed
    const test_tensor t = test_get_tensor(file, name);
    if (count) *count = t.count;
    return t.v;
}

static inline float* golden_floats(const test_tensors* file, const char* name, test_tensor* shape) { // to be freed
    test_tensor t = test_get_tensor(file, name);
    float* f = test_tensor_floats(&t);
    test_free_tensor(&t);
    if (shape) *shape = t;
    return f;
}

#endif
