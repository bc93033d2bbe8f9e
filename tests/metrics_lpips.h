// metrics_lpips.h - part of golden_metrics: LPIPS. The networks of the golden files are written as the folder of published
// files that gsf_nn_metric reads.
#ifndef METRICS_LPIPS_H
#define METRICS_LPIPS_H

#include "gsfixer_nn.h"
#include "test.h"
#include "test_hooks.h"

#if defined(__unix__) || defined(__APPLE__)
#include <sys/stat.h>
static void make_folder(const char* path) { (void)mkdir(path, 0777); }
#else
#include <direct.h>
static void make_folder(const char* path) { (void)_mkdir(path); }
#endif

static const struct { const char *name, *backbone, *heads; } lpips_files[] = {
    {"alex", "alexnet-owt-7be5be79", "alex"},
    {"vgg", "vgg16-397923af", "vgg"},
    {"squeeze", "squeezenet1_1-b8a52dc0", "squeeze"},
};

// Writes the tensors PREFIX* of `weights`, without the prefix, those named "lin*" to one file and the rest to another.
static void lpips_write(gsf_context* ctx, const gsf_nn_weights* weights, int net, const char* folder) {
    char prefix[32], path[1200];
    gsf_nn_tensor* part = (gsf_nn_tensor*)malloc((weights->tensor_count + 1) * sizeof *part);
    const size_t size = (size_t)snprintf(prefix, sizeof prefix, "%s.", lpips_files[net].name);
    for (int heads = 0; heads < 2; heads++) {
        size_t count = 0;
        for (size_t i = 0; i < weights->tensor_count; i++) {
            const char* name = weights->tensors[i].name;
            if (strncmp(name, prefix, size) != 0 || (strncmp(name + size, "lin", 3) == 0) != heads) continue;
            part[count] = weights->tensors[i];
            part[count++].name = name + size;
        }
        CHECK(count > 0);
        snprintf(path, sizeof path, "%s/%s.safetensors", folder,
                 heads ? lpips_files[net].heads : lpips_files[net].backbone);
        CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, part, count));
    }
    free(part);
}

typedef struct lpips_net { // SMALL networks of all kinds, and the full SqueezeNet
    const char* key;
    gsf_nn_metric metric[2]; // scaled images, raw images
    double sum[2];           // of the distances
    int compared;            // features compared
} lpips_net;

enum { LPIPS_NETS = 4 };
static const char* const lpips_keys[LPIPS_NETS] = {"alex_small", "vgg_small", "squeeze_small", "squeeze_full"};
static const char* const lpips_measures[3] = {"lpips_alex", "lpips_vgg", "lpips_squeeze"}; // by kind

typedef struct lpips_seen { // through the tap: the terms and the features of the first image
    const test_tensors* features;
    const char *net, *pair;
    float terms[8];
    int count, compared;
} lpips_seen;

static void lpips_see(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns) {
    lpips_seen* seen = (lpips_seen*)user;
    if (strcmp(name, "terms") == 0) {
        seen->count = (int)columns;
        for (int64_t i = 0; i < columns && i < 8; i++) seen->terms[i] = data[i];
        return;
    }
    char key[800];
    snprintf(key, sizeof key, "%s.%s.a.feat%d", seen->net, seen->pair, (int)index / 2);
    test_tensor t = index % 2 ? (test_tensor){0} : test_find_tensor(seen->features, key);
    if (!t.v) return;
    double error = 0.0;
    CHECK(t.count == (size_t)(rows * columns));
    for (int64_t i = 0; i < rows * columns && t.count == (size_t)(rows * columns); i++) { // ReLU comes later
        const double got = data[i] < 0.0f ? 0.0 : (double)data[i], e = fabs(got - t.v[i % columns * rows + i / columns]);
        if (!(e <= error)) error = e;
    }
    const double bar = 1e-6 * test_max_abs(t.v, t.count);
    if (getenv("GSF_TEST_VERBOSE")) printf("%-40s %.3g of its largest\n", key, error / bar * 1e-6);
    CHECK(error <= 2.0 * bar);
    seen->compared++;
    test_free_tensor(&t);
}

// The network's float32 costs up to 3e-6 of the distance, mostly less than 1e-6; constant images cancel.
static void lpips_check(const char* what, double got, double expected, double distance) {
    const double bar = 5e-6 * fabs(distance) + 1e-9;
    if (getenv("GSF_TEST_VERBOSE")) printf("%-40s %.9g (%.2g)\n", what, got, (got - expected) / (fabs(expected) + 1e-99));
    test_compare(what, &got, &expected, 1, bar);
}

// Writes and opens all networks; the full one has a folder of its own.
static int lpips_open(gsf_context* ctx, lpips_net* nets) {
    static char folders[2][1024];
    gsf_nn_weights weights[2];
    snprintf(folders[0], sizeof folders[0], "%s", test_scratch("."));
    snprintf(folders[1], sizeof folders[1], "%s", test_scratch("full"));
    make_folder(folders[1]);
    for (int full = 0; full < 2; full++) {
        const char* name = full ? "metrics/lpips_squeeze_full.safetensors" : "metrics/lpips_small_weights.safetensors";
        if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_golden(name), NULL, &weights[full]))) return 0;
    }
    for (int i = 0; i < LPIPS_NETS; i++) {
        const int full = i == LPIPS_NETS - 1, net = full ? 2 : i;
        lpips_write(ctx, &weights[full], net, folders[full]);
        nets[i].key = lpips_keys[i];
        for (int raw = 0; raw < 2; raw++) {
            gsf_nn_metric* metric = &nets[i].metric[raw];
            memset(metric, 0, sizeof *metric);
            metric->kind = (gsf_nn_metric_kind)(GSF_NN_METRIC_LPIPS_ALEX + net);
            metric->raw = raw;
            metric->models = folders[full];
            CHECK_OK(ctx, gsf_nn_measure_frame(ctx, metric, NULL, NULL));
            CHECK(metric->state != NULL && metric->count == 0);
        }
    }
    for (int full = 0; full < 2; full++) gsf_nn_destroy_weights(ctx, &weights[full]);
    return 1;
}

// One pair of images against expected.json.
static void lpips_check_pair(gsf_context* ctx, lpips_net* nets, const test_tensors* features, const gsf_json* json,
                             const gsf_json_value* e, const gsf_image* a, const gsf_image* b) {
    for (int i = 0; i < LPIPS_NETS; i++)
        for (int raw = 0; raw < 2; raw++) {
            gsf_nn_metric* metric = &nets[i].metric[raw];
            lpips_seen seen = {features, nets[i].key, e->key, {0}, 0, 0};
            const gsf__nn_tap tap = {lpips_see, &seen};
            char key[160];
            snprintf(key, sizeof key, "lpips_%s%s", nets[i].key, raw ? "_raw01" : "");
            const gsf_json_value* value = gsf_find_json_member(json, e, key);
            if (!CHECK(value != NULL)) continue;
            metric->_tap = raw ? NULL : &tap;
            CHECK_OK(ctx, gsf_nn_measure_frame(ctx, metric, a, b));
            metric->_tap = NULL;
            lpips_check(key, metric->last, value->number, value->number);
            if (value->number > 0.0)
                test_note_error(lpips_measures[metric->kind], fabs(metric->last - value->number) / value->number);
            nets[i].sum[raw] += metric->last;
            if (raw) continue;
            snprintf(key, sizeof key, "lpips_%s_layers", nets[i].key);
            const gsf_json_value* terms = gsf_find_json_member(json, e, key);
            CHECK(terms && terms->count == (uint32_t)seen.count);
            for (int k = 0; terms && k < seen.count; k++)
                lpips_check(key, (double)seen.terms[k], gsf_find_json_element(json, terms, (uint32_t)k)->number, value->number);
            nets[i].compared += seen.compared;
        }
}

// What a stream must do besides: the mean, workers, processors, refusals.
static void lpips_check_stream(gsf_context* ctx, lpips_net* net, const gsf_image* a, const gsf_image* b) {
    gsf_context other;
    gsf_nn_metric metric;
    float bad[2 * 2 * 3] = {0};
    gsf_image tiny = gsf_wrap_image(bad, GSF_F32, 2, 2, 3);
    CHECK_NEAR(net->metric[0].score, net->sum[0] / (double)net->metric[0].count, 1e-15);
    test_context_zero(&other);
    work_backwards(&other);
    CHECK_OK(&other, gsf_init_context(&other));
    memset(&metric, 0, sizeof metric);
    metric.kind = net->metric[0].kind;
    metric.models = net->metric[0].models;
    CHECK_OK(ctx, gsf_nn_measure_frame(ctx, &net->metric[0], a, b));
    CHECK_OK(&other, gsf_nn_measure_frame(&other, &metric, a, b));
    CHECK(metric.last == net->metric[0].last && metric.count == 1 && metric.score == metric.last);
    CHECK_RESULT(&other, gsf_nn_measure_frame(&other, &metric, &tiny, &tiny), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(&other, gsf_nn_measure_frame(&other, &metric, a, &tiny), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(&other, gsf_nn_measure_frame(&other, &metric, a, NULL), GSF_ERROR_INVALID_ARGUMENT);
    gsf_image nan = {0};
    CHECK_OK(&other, gsf_make_image(&other, GSF_F32, a->width, a->height, 3, &nan));
    CHECK_OK(&other, gsf_convert_image(&other, a, &nan));
    ((float*)nan.data)[100] = NAN;
    CHECK_RESULT(&other, gsf_nn_measure_frame(&other, &metric, a, &nan), GSF_ERROR_NUMERIC);
    gsf_destroy_image(&other, &nan);
    CHECK(metric.count == 1);
    gsf_nn_destroy_metric(&other, &metric);
    metric.models = test_scratch("absent");
    CHECK_RESULT(&other, gsf_nn_measure_frame(&other, &metric, NULL, NULL), GSF_ERROR_NOT_FOUND);
    metric.models = NULL;
    CHECK_RESULT(&other, gsf_nn_measure_frame(&other, &metric, NULL, NULL), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(metric.state == NULL);
}

static void lpips_close(gsf_context* ctx, lpips_net* nets) {
    for (int i = 0; i < LPIPS_NETS; i++) {
        CHECK(nets[i].metric[0].count > 1 && (i == LPIPS_NETS - 1 || nets[i].compared > 0));
        for (int raw = 0; raw < 2; raw++) gsf_nn_destroy_metric(ctx, &nets[i].metric[raw]);
    }
}

#endif
