// metricnets_i2v.h - I2V subject (DINO) and background (DreamSim): every network alone on an image of its size, and whole
// clips through gsf_nn_metric. The models' folders are copies of the golden files under their published names.
#ifndef METRICNETS_I2V_H
#define METRICNETS_I2V_H

#include "metricnets_golden.h"

// What a network shows of one image.
typedef struct i2v_seen {
    const test_tensors* io;
    const char* prefix; // of the expected tensors
    const char *tokens, *block; // names of the tokens before the blocks and after the first
    int compared;
} i2v_seen;

static void i2v_see(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns) {
    i2v_seen* seen = (i2v_seen*)user;
    const char* what = strcmp(name, "embeddings") == 0  ? seen->tokens
                       : strcmp(name, "layer0") == 0    ? seen->block
                       : strcmp(name, "positions") == 0 ? "pos_embed"
                                                        : NULL;
    char key[128];
    (void)index;
    if (!what) return;
    snprintf(key, sizeof key, "%s.%s", seen->prefix, what);
    test_tensor t = test_find_tensor(seen->io, key);
    if (t.v && CHECK(t.count <= (size_t)(rows * columns) && t.dim[1] == (size_t)columns)) {
        golden_compare(key, data, &t, 1e-6);
        seen->compared++;
    }
    test_free_tensor(&t);
}

static float* i2v_pixels(const test_tensor* t) { // 8-bit values to [0,1]; freed by the caller
    float* pixels = test_tensor_floats(t);
    for (size_t i = 0; i < t->count; i++) pixels[i] /= 255.0f;
    return pixels;
}

// One tower on the image sK.image_u8.
static void i2v_check_tower(gsf_context* ctx, const gsf__tower* tower, const test_tensors* io, const char* image,
                            i2v_seen* seen, const char* feature) {
    const gsf__nn_tap tap = {i2v_see, seen};
    test_tensor in = test_get_tensor(io, image), expected = test_get_tensor(io, feature);
    float *pixels = i2v_pixels(&in), *out = (float*)malloc((size_t)tower->features * sizeof(float));
    CHECK(expected.count == (size_t)tower->features);
    CHECK_OK(ctx, gsf__tower_encode(ctx, "tower", tower, pixels, (int64_t)in.dim[1], (int64_t)in.dim[2], &tap, out));
    golden_compare(feature, out, &expected, 1e-6);
    free(pixels);
    free(out);
    test_free_tensor(&in);
    test_free_tensor(&expected);
}

// A clip through gsf_nn_metric.
typedef struct i2v_clip {
    const char* features; // expected, per frame
    test_tensors io;
    int compared;
} i2v_clip;

static void i2v_see_clip(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns) {
    i2v_clip* clip = (i2v_clip*)user;
    char key[128];
    if (strcmp(name, "feature") != 0 || rows != 1) return;
    snprintf(key, sizeof key, "clip.input_%s", strchr(clip->features, '_') + 1);
    if (index) snprintf(key, sizeof key, "clip.antialias.%ss", clip->features);
    test_tensor t = test_get_tensor(&clip->io, key);
    t.count = (size_t)columns;
    double* whole = t.v;
    if (index) t.v += (int64_t)(index - 1) * columns;
    golden_compare(key, data, &t, 2e-6);
    clip->compared++;
    free(whole);
}

static void i2v_check_clip(gsf_context* ctx, const char* folder, const char* models, gsf_nn_metric_kind kind,
                           const int32_t* heads, const golden_config* config) {
    i2v_clip clip = {kind == GSF_NN_METRIC_I2V_SUBJECT ? "frame_feature" : "frame_embedding", {0}, 0};
    const gsf__nn_tap tap = {i2v_see_clip, &clip};
    clip.io = test_open_tensors(golden_file(folder, "io.safetensors"));
    test_tensor frames = test_get_tensor(&clip.io, "clip.frames"), input = test_get_tensor(&clip.io, "clip.input_image");
    gsf_image reference = golden_image(&input, 0);
    gsf_nn_metric metric;
    memset(&metric, 0, sizeof metric);
    metric.kind = kind;
    metric.models = models;
    metric._heads = heads;
    metric._tap = &tap;
    const char* section = kind == GSF_NN_METRIC_I2V_SUBJECT ? "i2v_subject" : "i2v_background";
    for (size_t i = 0; i < frames.dim[0]; i++) {
        gsf_image frame = golden_image(&frames, i);
        CHECK_OK(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, i ? NULL : &reference));
        golden_near("conformity", metric.last, golden_number(config, section, "antialias", "conformity", (int)i), 2e-6);
        free(frame.data);
    }
    CHECK(metric.count == (int64_t)frames.dim[0] && clip.compared == (int)frames.dim[0] + 1);
    const double score = golden_number(config, section, "antialias", "score", -1);
    golden_near(section, metric.score, score, 2e-6);
    test_note_error(section, fabs(metric.score - score));
    gsf_nn_destroy_metric(ctx, &metric);
    gsf_image frame = golden_image(&frames, 0);
    metric.kind = kind;
    metric.models = models;
    metric._heads = heads;
    CHECK_RESULT(ctx, gsf_nn_measure_frame(ctx, &metric, &frame, NULL), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(metric.count == 0);
    gsf_nn_destroy_metric(ctx, &metric);
    golden_fail_memory(kind, models, heads, &frame, 1, kind == GSF_NN_METRIC_I2V_SUBJECT ? 1 : 5);
    free(frame.data);
    free(reference.data);
    test_free_tensor(&frames);
    test_free_tensor(&input);
    test_close_tensors(&clip.io);
}

// gsf__i2v_prepare as PIL does it for the input image, in 8 bits, and for frames, in float.
static void i2v_check_prepare(gsf_context* ctx, const char* folder, int whole, const char* pil) {
    test_tensors io = test_open_tensors(golden_file(folder, "io.safetensors"));
    test_tensor in = test_get_tensor(&io, "pre.image_u8_hwc"), bytes = test_get_tensor(&io, pil);
    test_tensor floats = test_get_tensor(&io, "pre.frame_float_aa_every4");
    gsf_image image = golden_image(&in, 0);
    enum { SIDE = GSF__I2V_SIDE, PART = SIDE / 4 };
    float* pixels = (float*)malloc(3 * SIDE * SIDE * sizeof(float));
    CHECK_OK(ctx, gsf__i2v_prepare(ctx, &image, whole, GSF_U8, pixels));
    size_t wrong = 0;
    for (size_t i = 0; i < 3 * SIDE * SIDE; i++)
        wrong += (double)(pixels[i] * 255.0f) != bytes.v[i % (SIDE * SIDE) * 3 + i / (SIDE * SIDE)];
    CHECK(bytes.count == 3 * SIDE * SIDE && wrong == 0);
    CHECK_OK(ctx, gsf__i2v_prepare(ctx, &image, whole, GSF_F32, pixels));
    double error = 0.0;
    for (size_t c = 0; c < 3; c++)
        for (size_t y = 0; y < PART; y++)
            for (size_t x = 0; x < PART; x++)
                error = fmax(error, fabs(255.0 * (double)pixels[(c * SIDE + 4 * y) * SIDE + 4 * x] -
                                         floats.v[(c * PART + y) * PART + x]));
    golden_near("pre.frame_float_aa", error, 0.0, 1e-4); // of 255
    free(pixels);
    free(image.data);
    test_free_tensor(&in);
    test_free_tensor(&bytes);
    test_free_tensor(&floats);
    test_close_tensors(&io);
}

static inline void check_dino(void) {
    gsf_context ctx;
    golden_config config;
    gsf__i2v net;
    gsf_nn_metric metric;
    char models[1024];
    test_context_init(&ctx);
    if (!golden_open_config(&ctx, "dino", &config)) return;
    const int32_t heads = (int32_t)golden_number(&config, "num_heads", NULL, NULL, -1);
    golden_make_models(&ctx, "dino_models", models);
    golden_copy(&ctx, "dino", "weights.safetensors", models, "dino_vitbase16_pretrain.safetensors");
    memset(&net, 0, sizeof net);
    memset(&metric, 0, sizeof metric);
    metric.kind = GSF_NN_METRIC_I2V_SUBJECT;
    metric.models = models;
    metric._heads = &heads;
    if (CHECK_OK(&ctx, gsf__i2v_open(&ctx, &metric, &net))) {
        test_tensors io = test_open_tensors(golden_file("dino", "io.safetensors"));
        for (int i = 0; i < 2; i++) { // s1 is not square: its positions are interpolated
            i2v_seen seen = {&io, i ? "s1" : "s0", "tokens", "block0", 0};
            i2v_check_tower(&ctx, &net.towers[0], &io, i ? "s1.image_u8" : "s0.image_u8", &seen, i ? "s1.cls" : "s0.cls");
            CHECK(seen.compared == 3);
        }
        test_close_tensors(&io);
    }
    gsf__i2v_close(&ctx, &net);
    i2v_check_prepare(&ctx, "dino", 0, "pre.pil_resize256_crop224");
    i2v_check_clip(&ctx, "dino", models, metric.kind, &heads, &config);
    golden_close_config(&ctx, &config);
}

static inline void check_dreamsim(void) {
    static const char* const files[][2] = {{"dino.safetensors", "dino_vitbase16_pretrain.safetensors"},
                                           {"clip.safetensors", "clip_vitb16_pretrain.safetensors"},
                                           {"open_clip.safetensors", "open_clip_vitb16_pretrain.safetensors"}};
    gsf_context ctx;
    golden_config config;
    gsf__i2v net;
    gsf_nn_metric metric;
    char models[1024], adapter[1100];
    int32_t heads[3];
    test_context_init(&ctx);
    if (!golden_open_config(&ctx, "dreamsim", &config)) return;
    golden_make_models(&ctx, "dreamsim_models", models);
    golden_make_models(&ctx, "dreamsim_models/ensemble_lora", adapter);
    golden_copy(&ctx, "dreamsim", "adapter_model.safetensors", adapter, "adapter_model.safetensors");
    golden_copy(&ctx, "dreamsim", "adapter_config.json", adapter, "adapter_config.json");
    const gsf_json_value* towers = gsf_find_json_member(&config.json, &config.json.values[0], "extractors");
    for (int i = 0; i < 3; i++) {
        const gsf_json_value* tower = gsf_find_json_element(&config.json, towers, (uint32_t)i);
        heads[i] = (int32_t)gsf_find_json_member(&config.json, tower, "num_heads")->number;
        golden_copy(&ctx, "dreamsim", files[i][0], models, files[i][1]);
    }
    memset(&net, 0, sizeof net);
    memset(&metric, 0, sizeof metric);
    metric.kind = GSF_NN_METRIC_I2V_BACKGROUND;
    metric.models = models;
    metric._heads = heads;
    if (CHECK_OK(&ctx, gsf__i2v_open(&ctx, &metric, &net))) {
        test_tensors io = test_open_tensors(golden_file("dreamsim", "io.safetensors"));
        for (int i = 0; i < 3; i++) {
            char prefix[32], feature[64];
            i2v_seen seen = {&io, prefix, "tokens_before_blocks.first32rows", "block0.first32rows", 0};
            snprintf(prefix, sizeof prefix, "s0.e%d", i);
            snprintf(feature, sizeof feature, "%s.feature", prefix);
            i2v_check_tower(&ctx, &net.towers[i], &io, "s0.image_u8", &seen, feature);
            CHECK(seen.compared == 2);
            for (int block = 0; block < 2; block++) {
                char name[64];
                snprintf(name, sizeof name, "merged_qkv.%d.block%d", i, block);
                test_tensor t = test_find_tensor(&io, name);
                if (t.v) golden_compare(name, (const float*)net.towers[i].qkv[block].data, &t, 1e-6);
                test_free_tensor(&t);
            }
        }
        test_close_tensors(&io);
    }
    gsf__i2v_close(&ctx, &net);
    i2v_check_prepare(&ctx, "dreamsim", 1, "pre.pil_224x224");
    i2v_check_clip(&ctx, "dreamsim", models, metric.kind, heads, &config);
    golden_close_config(&ctx, &config);
}

#endif
