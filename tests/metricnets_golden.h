// metricnets_golden.h - shared by the parts of golden_metricnets.
#ifndef METRICNETS_GOLDEN_H
#define METRICNETS_GOLDEN_H

#include "test.h"
#include "test_hooks.h"

#if defined(__unix__) || defined(__APPLE__)
#include <sys/stat.h>
static inline void golden_make_folder(const char* path) { (void)mkdir(path, 0777); }
#else
#include <direct.h>
static inline void golden_make_folder(const char* path) { (void)_mkdir(path); }
#endif

static inline const char* golden_file(const char* folder, const char* name) { // static buffer
    static char path[2048];
    char inner[512];
    snprintf(inner, sizeof inner, "metricnets/%s/%s", folder, name);
    snprintf(path, sizeof path, "%s", test_golden(inner));
    return path;
}

static inline void golden_make_models(gsf_context* ctx, const char* name, char out[1024]) {
    (void)ctx;
    snprintf(out, 1024, "%s", test_scratch(name));
    golden_make_folder(out);
}

static inline void golden_copy(gsf_context* ctx, const char* folder, const char* name, const char* models, const char* as) {
    size_t size;
    char path[1200];
    char* data = test_read_file(golden_file(folder, name), &size);
    snprintf(path, sizeof path, "%s/%s", models, as);
    CHECK_OK(ctx, gsf_write_file(ctx, path, data, size));
    free(data);
}

// Errors relative to the largest expected value.
static inline void golden_compare(const char* what, const float* got, const test_tensor* expected, double bar) {
    const double scale = test_max_abs(expected->v, expected->count);
    double worst = 0.0;
    for (size_t i = 0; i < expected->count; i++) {
        const double error = fabs((double)got[i] - expected->v[i]) / scale;
        if (!(error <= worst)) worst = error;
    }
    if (getenv("GSF_TEST_VERBOSE")) printf("%-44s %.2g (bar %.2g)\n", what, worst, bar);
    if (!CHECK(worst <= bar)) fprintf(stderr, "    %s: relative error %.3g, allowed %.3g\n", what, worst, bar);
}

static inline void golden_near(const char* what, double got, double expected, double bar) {
    if (getenv("GSF_TEST_VERBOSE")) printf("%-44s %.2g (bar %.2g)\n", what, fabs(got - expected), bar);
    test_compare(what, &got, &expected, 1, bar);
}

// Image `index` of bytes (images, height, width, 3) or (height, width, 3); the caller frees its data.
static inline gsf_image golden_image(const test_tensor* t, size_t index) {
    const size_t *dim = t->dim + (t->rank - 3), count = dim[0] * dim[1] * dim[2];
    uint8_t* data = (uint8_t*)malloc(count);
    CHECK(dim[2] == 3);
    for (size_t i = 0; i < count; i++) data[i] = (uint8_t)t->v[index * count + i];
    return gsf_wrap_image(data, GSF_U8, (int64_t)dim[1], (int64_t)dim[0], 3);
}

typedef struct golden_config { gsf_json json; char* text; } golden_config;

static inline int golden_open_config(gsf_context* ctx, const char* folder, golden_config* out) {
    size_t size;
    out->text = test_read_file(golden_file(folder, "config.json"), &size);
    return CHECK_OK(ctx, gsf_parse_json(ctx, "config.json", out->text, size, &out->json));
}

static inline void golden_close_config(gsf_context* ctx, golden_config* config) {
    gsf_destroy_json(ctx, &config->json);
    free(config->text);
}

// The number below up to three keys, and at `index` of a list unless that is negative.
static inline double golden_number(const golden_config* config, const char* a, const char* b, const char* c, int index) {
    const char* const keys[3] = {a, b, c};
    const gsf_json_value* value = &config->json.values[0];
    for (int i = 0; i < 3 && value && keys[i]; i++) value = gsf_find_json_member(&config->json, value, keys[i]);
    if (value && index >= 0) value = gsf_find_json_element(&config->json, value, (uint32_t)index);
    return CHECK(value && value->type == GSF_JSON_NUMBER) ? value->number : NAN;
}

// Opens a metric and measures `count` frames, with every `step`-th allocation failing in turn: the error is that one, and
// nothing leaks.
static inline void golden_fail_memory(gsf_nn_metric_kind kind, const char* models, const int32_t* heads,
                                      const gsf_image* frames, int count, size_t step) {
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    size_t k = 1;
    for (; result != GSF_OK && k < 2000; k += step) {
        gsf_context ctx;
        gsf_nn_metric metric;
        counter c;
        memset(&c, 0, sizeof c);
        memset(&metric, 0, sizeof metric);
        test_context_zero(&ctx);
        count_memory(&ctx, &c);
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        metric.kind = kind;
        metric.models = models;
        metric._heads = heads;
        c.fail_at = k;
        result = gsf_nn_measure_frame(&ctx, &metric, NULL, NULL);
        for (int i = 0; i < count && result == GSF_OK; i++)
            result = gsf_nn_measure_frame(&ctx, &metric, &frames[i], &frames[0]);
        CHECK_RESULT(&ctx, result, c.calls < k ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY);
        gsf_nn_destroy_metric(&ctx, &metric);
        CHECK(c.live == 0);
    }
    CHECK(k > 20 && result == GSF_OK);
}

#endif
