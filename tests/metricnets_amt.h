// metricnets_amt.h - AMT-S: its layers alone (op.*), intermediates of two pairs of frames, whole clips.
#ifndef METRICNETS_AMT_H
#define METRICNETS_AMT_H

#include "metricnets_golden.h"

// Expected tensors are channels first, and may hold every 2nd or 4th pixel of each row and column; a map arrives pixel by
// pixel. Every kind of map is collected, then compared.
typedef struct amt_map { char name[32]; int index; int64_t pixels, channels; float* v; } amt_map;
typedef struct amt_seen { amt_map maps[64]; int count; } amt_seen;

static void amt_see(void* user, const char* name, int32_t index, const float* data, int64_t pixel, int64_t channels) {
    amt_seen* seen = (amt_seen*)user;
    amt_map* m = seen->maps;
    while (m < seen->maps + seen->count && (strcmp(m->name, name) != 0 || m->index != index)) m++;
    if (m == seen->maps + seen->count) {
        if (!CHECK(++seen->count <= 64)) exit(2);
        memset(m, 0, sizeof *m);
        snprintf(m->name, sizeof m->name, "%s", name);
        m->index = index;
        m->channels = channels;
    }
    CHECK(pixel <= m->pixels && channels == m->channels);
    if (pixel == m->pixels) {
        if ((pixel & (pixel - 1)) == 0) { // grows at powers of two
            const size_t room = (size_t)(pixel ? 2 * pixel : 1);
            m->v = (float*)realloc(m->v, room * (size_t)channels * sizeof(float));
        }
        m->pixels++;
    }
    memcpy(m->v + pixel * channels, data, (size_t)channels * sizeof(float));
}

static double amt_sigmoid(double x) { return 1.0 / (1.0 + exp(-x)); }
static double amt_same(double x) { return x; }
static double amt_clamp(double x) { return x < 0.0 ? 0.0 : x > 1.0 ? 1.0 : x; }

// Channels `first` ... of a map of `width` pixels a row, starting at pixel (left, top), against an expected tensor. Returns
// whether there is one.
static int amt_compare(const test_tensors* io, const char* pair, const char* name, const amt_seen* seen, const char* map,
                       int index, int64_t width, int64_t first, int64_t left, int64_t top, double (*f)(double), double bar) {
    static const char* const parts[] = {"", ".every2", ".every4"};
    const amt_map* m = seen->maps;
    while (m < seen->maps + seen->count && (strcmp(m->name, map) != 0 || m->index != index)) m++;
    if (!CHECK(m < seen->maps + seen->count)) return 0;
    for (int64_t step = 1, i = 0; i < 3; step *= 2, i++) {
        char key[96];
        snprintf(key, sizeof key, "%s.%s%s", pair, name, parts[i]);
        test_tensor t = test_find_tensor(io, key);
        if (!t.v) continue;
        float* got = (float*)malloc(t.count * sizeof(float));
        size_t at = 0;
        for (size_t c = 0; c < t.dim[0]; c++)
            for (size_t y = 0; y < t.dim[1]; y++)
                for (size_t x = 0; x < t.dim[2]; x++) {
                    const int64_t pixel = ((int64_t)y * step + top) * width + (int64_t)x * step + left;
                    const int inside = pixel < m->pixels && first + (int64_t)c < m->channels;
                    got[at++] = inside ? (float)f((double)m->v[pixel * m->channels + first + (int64_t)c]) : NAN;
                }
        golden_compare(key, got, &t, bar);
        free(got);
        test_free_tensor(&t);
        return 1;
    }
    return 0;
}

static void amt_check_pair(gsf_context* ctx, gsf__amt* net, const test_tensors* io, const char* pair) {
    char key[64];
    snprintf(key, sizeof key, "%s.img0", pair);
    test_tensor a = test_get_tensor(io, key);
    snprintf(key, sizeof key, "%s.img1", pair);
    test_tensor b = test_get_tensor(io, key);
    snprintf(key, sizeof key, "%s.imgt_u8", pair);
    test_tensor expected = test_get_tensor(io, key);
    gsf_image images[2] = {golden_image(&a, 0), golden_image(&b, 0)}, out;
    amt_seen seen;
    memset(&seen, 0, sizeof seen);
    const gsf__nn_tap tap = {amt_see, &seen};
    net->tap = &tap;
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, images[0].width, images[0].height, 3, &out));
    CHECK_OK(ctx, gsf__amt_middle(ctx, net, &images[0], &images[1], &out));
    net->tap = NULL;
    const int64_t wide = (images[0].width + 15) / 16 * 16, high = (images[0].height + 15) / 16 * 16;
    int compared = 0;
    for (int i = 0; i < 2; i++) {
        snprintf(key, sizeof key, "feat_encoder.out%d", i);
        compared += amt_compare(io, pair, key, &seen, "feat_encoder", i, wide / 8, 0, 0, 0, amt_same, 2e-5);
    }
    for (int scale = 0; scale < 4; scale++) {
        snprintf(key, sizeof key, "encoder_img1.pyramid%d", scale);
        compared += amt_compare(io, pair, key, &seen, "pyramid", 2 * scale + 1, wide >> (scale + 1), 0, 0, 0, amt_same, 2e-5);
        const int64_t across = wide >> scale; // of what the decoder gives: flows, then features or mask and residual
        for (int k = 0; k < 4; k++) {
            static const int64_t fine[4] = {0, 6, 12, 15}, coarse[4] = {0, 2, 4, 0};
            snprintf(key, sizeof key, "decoder%d.out%d", scale + 1, k);
            if (k < 3 || scale == 0)
                compared += amt_compare(io, pair, key, &seen, "decoder", 2 * scale, across, scale ? coarse[k] : fine[k], 0, 0,
                                        scale == 0 && k == 2 ? amt_sigmoid : amt_same, 2e-5);
        }
        static const char* const parts[] = {"in_flow", "corr", "out0", "out1"};
        for (int k = 0; k < 4 && scale > 0; k++) {
            char map[32];
            snprintf(key, sizeof key, "update%d.%s", scale + 1, parts[k]);
            snprintf(map, sizeof map, "update.%s", parts[k]);
            compared += amt_compare(io, pair, key, &seen, map, 2 * scale, k < 2 ? wide / 8 : across, 0, 0, 0, amt_same, 2e-5);
        }
    }
    compared += amt_compare(io, pair, "imgt_pred", &seen, "middle", 0, wide, 0, (wide - images[0].width) / 2,
                            (high - images[0].height) / 2, amt_clamp, 2e-5);
    CHECK(compared >= 4);
    size_t wrong = 0, remote = 0;
    for (size_t i = 0; i < expected.count; i++) {
        const double error = fabs((double)((const uint8_t*)out.data)[i] - expected.v[i]);
        wrong += error > 0.0;
        remote += error > 1.0;
    }
    golden_near("share of other grey levels", (double)wrong / (double)expected.count, 0.0, 5e-4);
    CHECK(remote == 0);
    for (int i = 0; i < seen.count; i++) free(seen.maps[i].v);
    gsf_destroy_image(ctx, &out);
    free(images[0].data);
    free(images[1].data);
    test_free_tensor(&a);
    test_free_tensor(&b);
    test_free_tensor(&expected);
}

static void amt_check_clip(gsf_context* ctx, const test_tensors* io, const char* models, const char* clip, double score) {
    char key[64];
    gsf_nn_metric metric;
    memset(&metric, 0, sizeof metric);
    metric.kind = GSF_NN_METRIC_MOTION_SMOOTHNESS;
    metric.models = models;
    snprintf(key, sizeof key, "ms.%s.frames", clip);
    test_tensor frames = test_get_tensor(io, key);
    for (size_t i = 0; i < frames.dim[0]; i++) {
        gsf_image frame = golden_image(&frames, i);
        CHECK_OK(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL));
        free(frame.data);
    }
    CHECK(metric.count == (int64_t)frames.dim[0]);
    golden_near(key, metric.score, score, 1e-6);
    test_note_error("motion_smoothness", fabs(metric.score - score));
    if (frames.dim[0] % 2) {
        gsf_image three[3];
        for (size_t i = 0; i < 3; i++) three[i] = golden_image(&frames, i);
        golden_fail_memory(metric.kind, models, NULL, three, 3, 7);
        for (int i = 0; i < 3; i++) free(three[i].data);
    }
    uint8_t little[48 * 48 * 3] = {0};
    const gsf_image other = gsf_wrap_image(little, GSF_U8, 48, 48, 3);
    CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &other, NULL), GSF_ERROR_INVALID_ARGUMENT);
    gsf_nn_destroy_metric(ctx, &metric);
    metric.kind = GSF_NN_METRIC_MOTION_SMOOTHNESS;
    metric.models = models;
    for (int i = 0; i < 3; i++)
        CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &other, NULL), i < 2 ? GSF_OK : GSF_ERROR_DEGENERATE);
    gsf_nn_destroy_metric(ctx, &metric);
    test_free_tensor(&frames);
}

// A map of channels last from a tensor of channels first; images of a batch are taken as one.
static gsf__map amt_map_of(const test_tensor* t) {
    const size_t* dim = t->dim + (t->rank - 3);
    const gsf__map map = {(float*)malloc(t->count * sizeof(float)), 1, (int64_t)dim[1], (int64_t)dim[2], (int64_t)dim[0],
                          (int64_t)dim[0]};
    for (size_t i = 0; i < t->count; i++) map.data[i % (dim[1] * dim[2]) * dim[0] + i / (dim[1] * dim[2])] = (float)t->v[i];
    return map;
}

static void amt_compare_map(const test_tensors* io, const char* key, const gsf__map* map, int64_t step, double bar) {
    test_tensor t = test_get_tensor(io, key);
    const size_t* dim = t.dim + (t.rank - 3);
    float* got = (float*)malloc(t.count * sizeof(float));
    size_t at = 0;
    CHECK((int64_t)dim[0] == map->channels && ((int64_t)dim[1] - 1) * step < map->height);
    for (size_t c = 0; c < dim[0]; c++)
        for (size_t y = 0; y < dim[1]; y++)
            for (size_t x = 0; x < dim[2]; x++)
                got[at++] = map->data[((int64_t)y * step * map->width + (int64_t)x * step) * map->pitch + (int64_t)c];
    golden_compare(key, got, &t, bar);
    free(got);
    test_free_tensor(&t);
}

static void amt_check_layers(gsf_context* ctx, const test_tensors* io) {
    static const struct { const char* name; double scale; } resizes[] = {{"op.resize.x0.25", 0.25}, {"op.resize.x0.5", 0.5},
                                                                        {"op.resize.x2", 2.0}, {"op.resize.x4", 4.0}};
    gsf__amt net;
    gsf__map y;
    memset(&net, 0, sizeof net);
    net.ctx = ctx;
    test_tensor t = test_get_tensor(io, "op.resize.in");
    gsf__map x = amt_map_of(&t);
    for (int i = 0; i < 4; i++) {
        const int64_t high = (int64_t)((double)x.height * resizes[i].scale);
        const int64_t wide = (int64_t)((double)x.width * resizes[i].scale);
        CHECK_OK(ctx, gsf__amt_make(&net, 1, high, wide, x.channels, &y));
        gsf__amt_resize(&net, &x, resizes[i].scale, 1.0, &y);
        amt_compare_map(io, resizes[i].name, &y, 1, 1e-6);
    }
    CHECK_OK(ctx, gsf__amt_norm(&net, 0, &x)); // the golden norm has the resize's input
    amt_compare_map(io, "op.instance_norm.out", &x, 1, 1e-6);
    free(x.data);
    test_free_tensor(&t);

    test_tensor in = test_get_tensor(io, "op.warp.in"), flow = test_get_tensor(io, "op.warp.flow");
    x = amt_map_of(&in);
    gsf__map along = amt_map_of(&flow);
    CHECK_OK(ctx, gsf__amt_make(&net, 1, x.height, x.width, x.channels, &y));
    gsf__amt_warp(&net, &x, &along, &y);
    amt_compare_map(io, "op.warp.out", &y, 1, 1e-6);
    free(x.data);
    free(along.data);
    test_free_tensor(&in);
    test_free_tensor(&flow);

    t = test_get_tensor(io, "op.resize.in");
    test_tensor weight = test_get_tensor(io, "op.convT.weight"), bias = test_get_tensor(io, "op.convT.bias");
    float *w = test_tensor_floats(&weight), *b = test_tensor_floats(&bias);
    int64_t shape[4];
    for (int i = 0; i < 4; i++) shape[i] = (int64_t)weight.dim[i];
    const gsf_nn_tensor weights = gsf_nn_wrap_tensor("w", w, 4, shape), biases = gsf_nn_wrap_tensor("b", b, 1, shape + 1);
    const gsf__nn_layer layer = {&weights, &biases};
    x = amt_map_of(&t);
    CHECK_OK(ctx, gsf__amt_make(&net, 1, 2 * x.height, 2 * x.width, shape[1], &y));
    CHECK_OK(ctx, gsf__amt_up(&net, &layer, &x, &y));
    amt_compare_map(io, "op.convT.out", &y, 1, 1e-6);
    free(x.data);
    free(w);
    free(b);
    test_free_tensor(&t);
    test_free_tensor(&weight);
    test_free_tensor(&bias);

    // the lookup: coords = position + 2 * flow
    gsf__map pyramids[2][GSF__AMT_LEVELS], maps[2];
    for (int i = 0; i < 2; i++) {
        t = test_get_tensor(io, i ? "op.corr.fmap1" : "op.corr.fmap0");
        maps[i] = amt_map_of(&t);
        CHECK_OK(ctx, gsf__amt_make_pyramid(&net, &maps[i], pyramids[i]));
        test_free_tensor(&t);
    }
    for (int i = 0; i < 2; i++) {
        t = test_get_tensor(io, i ? "op.corr.coords1" : "op.corr.coords0");
        gsf__map way = amt_map_of(&t);
        for (int64_t k = 0; k < way.height * way.width; k++) {
            way.data[2 * k] = (way.data[2 * k] - (float)(k % way.width)) / 2.0f;
            way.data[2 * k + 1] = (way.data[2 * k + 1] - (float)(k / way.width)) / 2.0f;
        }
        CHECK_OK(ctx, gsf__amt_make(&net, 1, way.height, way.width, GSF__AMT_LOOKUP, &y));
        gsf__amt_lookup_job job = {gsf__map_kernels_of(ctx->cpu_level), &pyramids[i][0], pyramids[!i], &way, &y};
        gsf__parallel_for(ctx, (size_t)way.height, gsf__amt_lookup_row, &job);
        amt_compare_map(io, i ? "op.corr.out1.every4" : "op.corr.out0.every4", &y, 4, 2e-6);
        free(way.data);
        test_free_tensor(&t);
    }
    free(maps[0].data);
    free(maps[1].data);
    gsf__amt_close(ctx, &net);
}

static inline void check_amt(void) {
    gsf_context ctx;
    golden_config config;
    gsf_nn_metric metric;
    gsf__amt net;
    char models[1024];
    test_context_init(&ctx);
    if (!golden_open_config(&ctx, "amt", &config)) return;
    golden_make_models(&ctx, "amt_models", models);
    golden_copy(&ctx, "amt", "weights.safetensors", models, "amt-s.safetensors");
    test_tensors io = test_open_tensors(golden_file("amt", "io.safetensors"));
    amt_check_layers(&ctx, &io);
    memset(&metric, 0, sizeof metric);
    memset(&net, 0, sizeof net);
    metric.models = models;
    if (CHECK_OK(&ctx, gsf__amt_open(&ctx, &metric, &net)))
        for (int i = 0; i < 2; i++) amt_check_pair(&ctx, &net, &io, i ? "p1" : "p0");
    gsf__amt_close(&ctx, &net);
    const gsf_json_value* clips = gsf_find_json_member(&config.json, &config.json.values[0], "motion_smoothness");
    CHECK(clips && clips->child);
    for (uint32_t i = clips ? clips->child : 0; i; i = config.json.values[i].next)
        if (config.json.values[i].type == GSF_JSON_OBJECT)
            amt_check_clip(&ctx, &io, models, config.json.values[i].key,
                           golden_number(&config, "motion_smoothness", config.json.values[i].key, "score", -1));
    test_close_tensors(&io);
    golden_close_config(&ctx, &config);
}

#endif
