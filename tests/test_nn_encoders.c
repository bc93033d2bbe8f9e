// The encoders of reference photos on the small golden models: invalid folders and inputs, workers, groups of images,
// memory, cancellation, saving and loading features. golden_encoders checks their values.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

enum { IMAGE_HEIGHT = 28, IMAGE_WIDTH = 42, IMAGES = 3, ROOM = 1 << 20 };

static float pixels[IMAGES * 3 * IMAGE_HEIGHT * IMAGE_WIDTH];

typedef struct edit { // changes to a model's files; NULL: unchanged
    const char *drop, *widen, *add, *poison; // tensors to remove, to give an extra dimension, to add, to put a NaN into
    const char *from, *to;                   // replacement in config.json
    int no_config;
} edit;

// Copies the golden model of that name to the scratch folder with these changes.
static const char* write_model(gsf_context* ctx, const char* name, const edit* e) {
    static const float one[1] = {1.0f};
    static const int64_t single[1] = {1};
    char path[200];
    gsf_nn_weights w;
    size_t count = 0, size;
    snprintf(path, sizeof path, "encoders/%s/config.json", name);
    char* config = test_read_file(test_golden(path), &size);
    snprintf(path, sizeof path, "encoders/%s", name);
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_golden(path), NULL, &w));
    gsf_nn_tensor* tensors = (gsf_nn_tensor*)malloc((w.tensor_count + 1) * sizeof *tensors);
    float* poisoned = NULL;
    for (size_t i = 0; i < w.tensor_count; i++) {
        gsf_nn_tensor* t = &tensors[count];
        if (e->drop && strcmp(w.tensors[i].name, e->drop) == 0) continue;
        *t = w.tensors[i];
        count++;
        if (e->widen && strcmp(t->name, e->widen) == 0) t->shape[t->rank++] = 1;
        if (e->poison && strcmp(t->name, e->poison) == 0) {
            poisoned = (float*)malloc((size_t)t->count * sizeof(float));
            gsf_nn_convert_tensor(t, 0, t->count, poisoned);
            poisoned[t->count / 2] = NAN;
            t->data = poisoned;
        }
    }
    if (e->add) tensors[count++] = gsf_nn_wrap_tensor(e->add, one, 1, single);
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("model.safetensors"), tensors, count));
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    const char* at = e->from ? strstr(config, e->from) : NULL;
    if (at) {
        gsf_append_bytes(ctx, &text, config, (size_t)(at - config));
        gsf_append_bytes(ctx, &text, e->to, strlen(e->to));
        at += strlen(e->from);
    }
    gsf_append_bytes(ctx, &text, at ? at : config, strlen(at ? at : config));
    CHECK(!e->from || at);
    if (e->no_config) remove(test_scratch("config.json"));
    else CHECK_OK(ctx, gsf_write_file(ctx, test_scratch("config.json"), text.data, text.size));
    gsf_destroy_buffer(ctx, &text);
    gsf_nn_destroy_weights(ctx, &w);
    free(tensors);
    free(poisoned);
    free(config);
    return test_scratch(".");
}

static gsf_nn_encoder_desc small_input(void) {
    gsf_nn_encoder_desc in;
    memset(&in, 0, sizeof in);
    in.pixels = pixels;
    in.images = IMAGES;
    in.height = IMAGE_HEIGHT;
    in.width = IMAGE_WIDTH;
    return in;
}

// ---- folders ---------------------------------------------------------------------

typedef struct bad_folder {
    edit e;
    gsf_result wanted;
    const char* named; // expected in the error message
} bad_folder;

static void test_bad_dinov2(gsf_context* ctx) {
    static const bad_folder cases[] = {
        {{"encoder.layer.1.mlp.fc1.bias", 0, 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "encoder.layer.1.mlp.fc1.bias is missing"},
        {{0, "layernorm.weight", 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "layernorm.weight has shape"},
        {{0, 0, "encoder.layer.99.norm1.weight", 0, 0, 0, 0}, GSF_ERROR_FORMAT, "encoder.layer.99.norm1.weight"},
        {{0, 0, 0, 0, "\"use_swiglu_ffn\": false", "\"use_swiglu_ffn\": true", 0}, GSF_ERROR_UNSUPPORTED, "use_swiglu_ffn"},
        {{0, 0, 0, 0, "\"hidden_act\": \"gelu\"", "\"hidden_act\": \"mish\"", 0}, GSF_ERROR_UNSUPPORTED, "mish"},
        {{0, 0, 0, 0, "\"num_attention_heads\": ", "\"num_attention_heads\": 7", 0}, GSF_ERROR_UNSUPPORTED, "heads"},
        {{0, 0, 0, 0, "\"hidden_size\": ", "\"hidden_size\": -", 0}, GSF_ERROR_FORMAT, "hidden_size"},
        {{0, 0, 0, 0, "\"patch_size\": ", "\"patch_size\": 1", 0}, GSF_ERROR_UNSUPPORTED, "image_size"},
        {{0, 0, 0, 0, 0, 0, 1}, GSF_ERROR_NOT_FOUND, "config.json"}};
    gsf_nn_dinov2 net;
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        CHECK_RESULT(ctx, gsf_nn_load_dinov2(ctx, write_model(ctx, "dinov2_reg", &cases[i].e), &net), cases[i].wanted);
        if (!CHECK(strstr(ctx->error, cases[i].named) != NULL)) fprintf(stderr, "    %zu: %s\n", i, ctx->error);
        CHECK(net.nets == NULL && net.weights.tensors == NULL);
    }
}

static void test_bad_vggt(gsf_context* ctx) {
    static const bad_folder cases[] = {
        {{"aggregator.global_blocks.1.ls1.gamma", 0, 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "blocks.1.ls1.gamma is missing"},
        {{"aggregator.register_token", 0, 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "aggregator.register_token is missing"},
        {{0, "aggregator.camera_token", 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "aggregator.camera_token has shape"},
        {{0, "aggregator.patch_embed.patch_embed.proj.weight", 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "proj.weight has shape"},
        {{0, 0, "aggregator.surplus", 0, 0, 0, 0}, GSF_ERROR_FORMAT, "aggregator.surplus"},
        {{"aggregator.frame_blocks.1.norm1.weight", 0, 0, 0, 0, 0, 0}, GSF_ERROR_FORMAT, "1.norm1.weight is missing"},
        {{0, 0, 0, 0, "\"depth\": ", "\"depth\": 1", 0}, GSF_ERROR_FORMAT, "is missing"},
        {{0, 0, 0, 0, "\"depth\": ", "\"depth\": 1, \"was\": ", 0}, GSF_ERROR_FORMAT, "frame_blocks.1."},
        {{0, 0, 0, 0, "\"depth\": ", "\"depth\": -", 0}, GSF_ERROR_FORMAT, "depth"},
        {{0, 0, 0, 0, "\"embed_dim\": ", "\"embed_dim\": 1", 0}, GSF_ERROR_UNSUPPORTED, "heads"},
        {{0, 0, 0, 0, "\"num_heads\": ", "\"num_heads\": 7", 0}, GSF_ERROR_UNSUPPORTED, "heads"},
        {{0, 0, 0, 0, "\"frame\",", "\"global\",", 0}, GSF_ERROR_UNSUPPORTED, "aa_order"},
        {{0, 0, 0, 0, "\"qk_norm\": true", "\"qk_norm\": false", 0}, GSF_ERROR_FORMAT, "_norm."}};
    gsf_nn_vggt net;
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        CHECK_RESULT(ctx, gsf_nn_load_vggt(ctx, write_model(ctx, "vggt", &cases[i].e), &net), cases[i].wanted);
        if (!CHECK(strstr(ctx->error, cases[i].named) != NULL)) fprintf(stderr, "    %zu: %s\n", i, ctx->error);
        CHECK(net.nets == NULL && net.weights.tensors == NULL);
    }
}

// The model is the same without config.json, with additional tensors of other parts, and as one file.
static void test_vggt_alone(gsf_context* ctx, const float* expected, float* out) {
    const edit e = {0, 0, "depth_head.norm.weight", 0, 0, 0, 1};
    const gsf_nn_encoder_desc in = small_input();
    (void)write_model(ctx, "vggt", &e);
    for (int file = 0; file < 2; file++) {
        gsf_nn_vggt net;
        if (!CHECK_OK(ctx, gsf_nn_load_vggt(ctx, test_scratch(file ? "model.safetensors" : "."), &net))) return;
        const size_t count = (size_t)(IMAGES * (IMAGE_HEIGHT / net.patch) * (IMAGE_WIDTH / net.patch) * 2 * net.width);
        CHECK(net.layers > 0 && net.embed_layers > 0 && net.rope_base == 100.0 && net.width % net.heads == 0);
        CHECK_OK(ctx, gsf_nn_encode_vggt(ctx, &net, &in, out));
        CHECK(memcmp(out, expected, count * sizeof(float)) == 0);
        gsf_nn_destroy_vggt(ctx, &net);
    }
}

// The error names the weight that contains a NaN.
static void test_poison(gsf_context* ctx, float* out) {
    static const char* const dino[] = {"embeddings.register_tokens", "encoder.layer.1.norm2.weight", "layernorm.bias"};
    static const char* const vggt[] = {"aggregator.patch_embed.pos_embed", "aggregator.patch_embed.blocks.1.ls2.gamma",
                                       "aggregator.register_token", "aggregator.frame_blocks.1.attn.q_norm.weight",
                                       "aggregator.global_blocks.2.mlp.fc2.weight"};
    const gsf_nn_encoder_desc in = small_input();
    for (size_t i = 0; i < sizeof dino / sizeof dino[0] + sizeof vggt / sizeof vggt[0]; i++) {
        const int first = i < sizeof dino / sizeof dino[0];
        const char* name = first ? dino[i] : vggt[i - sizeof dino / sizeof dino[0]];
        const edit e = {0, 0, 0, name, 0, 0, 0};
        gsf_nn_dinov2 d;
        gsf_nn_vggt v;
        out[0] = 7.0f;
        if (first) {
            CHECK_OK(ctx, gsf_nn_load_dinov2(ctx, write_model(ctx, "dinov2_reg", &e), &d));
            CHECK_RESULT(ctx, gsf_nn_encode_dinov2(ctx, &d, &in, out), GSF_ERROR_NUMERIC);
            gsf_nn_destroy_dinov2(ctx, &d);
        } else {
            CHECK_OK(ctx, gsf_nn_load_vggt(ctx, write_model(ctx, "vggt", &e), &v));
            CHECK_RESULT(ctx, gsf_nn_encode_vggt(ctx, &v, &in, out), GSF_ERROR_NUMERIC);
            gsf_nn_destroy_vggt(ctx, &v);
        }
        if (!CHECK(strstr(ctx->error, name) != NULL)) fprintf(stderr, "    %s: %s\n", name, ctx->error);
        CHECK(out[0] == 0.0f);
    }
}

// ---- inputs ----------------------------------------------------------------------

static void test_bad_inputs(gsf_context* ctx, const gsf_nn_dinov2* dino, const gsf_nn_vggt* vggt, float* out) {
    static float nan_pixels[3 * IMAGE_HEIGHT * IMAGE_WIDTH];
    for (int kind = 0; kind < 2; kind++)
        for (int i = 0; i < 7; i++) {
            gsf_nn_encoder_desc in = small_input();
            if (i == 0) in.pixels = NULL;
            if (i == 1) in.images = 0;
            if (i == 2) in.height += 1;
            if (i == 3) in.width = 0;
            if (i == 4) in.height = -14;
            if (i == 5) in.width = 14 << 20;
            if (i == 6) {
                memcpy(nan_pixels, pixels, sizeof nan_pixels);
                nan_pixels[1234] = NAN;
                in.pixels = nan_pixels;
                in.images = 1;
            }
            const gsf_result wanted = i == 6 ? GSF_ERROR_NUMERIC : GSF_ERROR_INVALID_ARGUMENT;
            if (kind) CHECK_RESULT(ctx, gsf_nn_encode_vggt(ctx, vggt, &in, out), wanted);
            else CHECK_RESULT(ctx, gsf_nn_encode_dinov2(ctx, dino, &in, out), wanted);
        }
}

// ---- workers, groups, memory, cancelling --------------------------------------------

// On return, `expected` holds VGGT's tokens of the small images.
static void test_workers(const gsf_nn_dinov2* dino, const gsf_nn_vggt* vggt, float* expected, float* out) {
    gsf_context three;
    test_context_zero(&three);
    work_backwards(&three);
    if (gsf_init_context(&three) != GSF_OK) exit(2);
    gsf_context one;
    test_context_zero(&one);
    one.threads = 1;
    if (gsf_init_context(&one) != GSF_OK) exit(2);
    // enough rows for several blocks of the linear layers; then the small images
    enum { MORE = 5, HIGH = 98, WIDE = 182 };
    float* more = (float*)malloc(MORE * 3 * HIGH * WIDE * sizeof(float));
    for (size_t i = 0; i < MORE * 3 * HIGH * WIDE; i++) more[i] = pixels[i * 7 % (sizeof pixels / sizeof pixels[0])];
    for (int small = 0; small < 2; small++) {
        gsf_nn_encoder_desc in = small_input();
        if (!small) {
            in.pixels = more;
            in.images = MORE;
            in.height = HIGH;
            in.width = WIDE;
        }
        const size_t tokens = (size_t)(in.images * (in.height / dino->patch) * (in.width / dino->patch));
        CHECK(tokens * 2 * (size_t)vggt->width <= ROOM);
        CHECK_OK(&one, gsf_nn_encode_dinov2(&one, dino, &in, expected));
        CHECK_OK(&three, gsf_nn_encode_dinov2(&three, dino, &in, out));
        CHECK(memcmp(out, expected, tokens * (size_t)dino->width * sizeof(float)) == 0);
        CHECK_OK(&one, gsf_nn_encode_vggt(&one, vggt, &in, expected));
        CHECK_OK(&three, gsf_nn_encode_vggt(&three, vggt, &in, out));
        CHECK(memcmp(out, expected, tokens * 2 * (size_t)vggt->width * sizeof(float)) == 0);
    }
    free(more);
}

// Products of bfloat16 stay near those of float32, and do not depend on the workers either; other processors ignore it.
static void test_encoders_bf16(gsf_context* ctx, gsf_nn_dinov2* dino, gsf_nn_vggt* vggt, const float* expected, float* out) {
    const gsf_nn_encoder_desc in = small_input();
    const size_t tokens = (size_t)(IMAGES * (IMAGE_HEIGHT / dino->patch) * (IMAGE_WIDTH / dino->patch));
    const size_t counts[2] = {tokens * (size_t)dino->width, tokens * 2 * (size_t)vggt->width};
    gsf_context three;
    test_context_zero(&three);
    work_backwards(&three);
    CHECK_OK(&three, gsf_init_context(&three));
    float *plain = (float*)malloc(counts[0] * sizeof(float)), *again = (float*)malloc(counts[1] * sizeof(float));
    CHECK_OK(ctx, gsf_nn_encode_dinov2(ctx, dino, &in, plain));
    dino->bf16 = vggt->bf16 = 1;
    for (int kind = 0; kind < 2; kind++) {
        const float* from = kind ? expected : plain;
        CHECK_OK(ctx, kind ? gsf_nn_encode_vggt(ctx, vggt, &in, out) : gsf_nn_encode_dinov2(ctx, dino, &in, out));
        CHECK_OK(&three, kind ? gsf_nn_encode_vggt(&three, vggt, &in, again) : gsf_nn_encode_dinov2(&three, dino, &in, again));
        CHECK(memcmp(out, again, counts[kind] * sizeof(float)) == 0);
        const double error = test_relative_error(out, from, counts[kind]);
        if (ctx->cpu_level == GSF_CPU_AVX512_BF16 || ctx->cpu_level == GSF_CPU_AMX) CHECK(error > 1e-5 && error < 2e-2);
        else CHECK(error == 0.0);
        if (getenv("GSF_TEST_VERBOSE")) printf("bf16 %s: relative L2 error %.3g\n", kind ? "vggt" : "dinov2", error);
    }
    dino->bf16 = vggt->bf16 = 0;
    free(plain);
    free(again);
}

// More images than one group holds: each is encoded as it is alone.
static void test_groups(gsf_context* ctx, const gsf_nn_dinov2* dino, float* out) {
    enum { MANY = 420 };
    gsf_nn_encoder_desc in = small_input();
    const size_t image = (size_t)(3 * IMAGE_HEIGHT * IMAGE_WIDTH), count = (size_t)(6 * dino->width);
    float *many = (float*)malloc(MANY * image * sizeof(float)), *whole = (float*)malloc(MANY * count * sizeof(float));
    for (size_t i = 0; i < MANY; i++)
        for (size_t k = 0; k < image; k++) many[i * image + k] = pixels[i % IMAGES * image + k] * (float)(i + 1) / MANY;
    in.images = MANY;
    in.pixels = many;
    CHECK(IMAGE_HEIGHT / dino->patch * (IMAGE_WIDTH / dino->patch) == 6);
    CHECK_OK(ctx, gsf_nn_encode_dinov2(ctx, dino, &in, whole));
    in.images = 1;
    for (size_t i = 0; i < MANY; i += i < 3 || i > MANY - 5 ? 1 : 40) {
        in.pixels = many + i * image;
        CHECK_OK(ctx, gsf_nn_encode_dinov2(ctx, dino, &in, out));
        double worst = 0.0;
        for (size_t k = 0; k < count; k++) worst = fmax(worst, fabs((double)(out[k] - whole[i * count + k])));
        CHECK_NEAR(worst, 0.0, 1e-5);
    }
    free(many);
    free(whole);
}

// Each allocation fails once. The bytes counted are those that the cost query reports plus the kernels' scratch memory.
static void test_encoder_memory(float* out) {
    const gsf_nn_encoder_desc in = small_input();
    gsf_context ctx;
    counter count;
    test_context_zero(&ctx);
    memset(&count, 0, sizeof count);
    ctx.threads = 1;
    count_memory(&ctx, &count);
    if (gsf_init_context(&ctx) != GSF_OK) exit(2);
    for (int kind = 0; kind < 2; kind++)
        for (size_t k = 1;; k++) {
            gsf_nn_dinov2 dino;
            gsf_nn_vggt vggt;
            double bytes = 0.0, flops = 0.0;
            memset(&dino, 0, sizeof dino);
            memset(&vggt, 0, sizeof vggt);
            count.calls = 0;
            count.fail_at = k;
            gsf_result result = kind ? gsf_nn_load_vggt(&ctx, test_golden("encoders/vggt"), &vggt)
                                     : gsf_nn_load_dinov2(&ctx, test_golden("encoders/dinov2_reg"), &dino);
            count.asked = 0;
            if (!result) {
                if (kind) gsf__nn_query_vggt(&vggt, &in, &bytes, &flops);
                else gsf__nn_query_dinov2(&dino, &in, &bytes, &flops);
                result = kind ? gsf_nn_encode_vggt(&ctx, &vggt, &in, out) : gsf_nn_encode_dinov2(&ctx, &dino, &in, out);
            }
            gsf_nn_destroy_dinov2(&ctx, &dino);
            gsf_nn_destroy_vggt(&ctx, &vggt);
            CHECK(count.live == 0);
            if (!result) {
                CHECK(count.calls < k && flops > 1e6);
                CHECK(bytes > 1e4 && bytes < (double)count.asked);
                break;
            }
            if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
        }
}

typedef struct stopper { gsf_context* ctx; double after, last, total; } stopper;
static void stop_at(void* user, const char* stage, double done, double total) {
    stopper* s = (stopper*)user;
    (void)stage;
    CHECK(done == s->last + 1.0 && done <= total);
    s->last = done;
    s->total = total;
    if (done == s->after) gsf_request_cancel(s->ctx);
}

static void test_cancel(gsf_context* ctx, const gsf_nn_vggt* vggt, float* out) {
    const gsf_nn_encoder_desc in = small_input();
    stopper s = {ctx, 0.0, 0.0, 0.0};
    ctx->progress.progress_fn = stop_at;
    ctx->progress.user = &s;
    CHECK_OK(ctx, gsf_nn_encode_vggt(ctx, vggt, &in, out));
    CHECK(s.last == s.total && s.total == vggt->embed_layers + 2 * vggt->layers);
    s.after = 2.0;
    s.last = 0.0;
    out[0] = 7.0f;
    CHECK_RESULT(ctx, gsf_nn_encode_vggt(ctx, vggt, &in, out), GSF_ERROR_CANCELLED);
    CHECK(s.last == 2.0 && out[0] == 0.0f);
    gsf_clear_cancel(ctx);
    memset(&ctx->progress, 0, sizeof ctx->progress);
}

// ---- from photos to tokens ---------------------------------------------------------

static void test_features(gsf_context* ctx, const gsf_nn_dinov2* dino, const gsf_nn_vggt* vggt) {
    gsf_image photos[2];
    gsf_nn_features both, turns;
    uint64_t seed = 3;
    memset(&both, 0, sizeof both);
    memset(&turns, 0, sizeof turns);
    for (int i = 0; i < 2; i++) { // wide, so that they give few tokens
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, 60, 5, 3, &photos[i]));
        for (int k = 0; k < 3 * 60 * 5; k++) ((uint8_t*)photos[i].data)[k] = (uint8_t)test_random_bits(&seed);
    }
    CHECK_OK(ctx, gsf_nn_encode_references(ctx, dino, vggt, photos, 2, &both));
    CHECK(both.images == 2 && both.tokens == 518 / dino->patch * (42 / dino->patch));
    CHECK(both.dino_channels == dino->width && both.vggt_channels == 2 * vggt->width);
    CHECK_OK(ctx, gsf_nn_encode_references(ctx, dino, NULL, photos, 2, &turns));
    CHECK(turns.dino && !turns.vggt);
    CHECK_OK(ctx, gsf_nn_encode_references(ctx, NULL, vggt, photos, 2, &turns));
    const size_t tokens = (size_t)(both.images * both.tokens);
    CHECK(memcmp(both.dino, turns.dino, tokens * (size_t)both.dino_channels * sizeof(float)) == 0);
    CHECK(memcmp(both.vggt, turns.vggt, tokens * (size_t)both.vggt_channels * sizeof(float)) == 0);

    CHECK_RESULT(ctx, gsf_nn_encode_references(ctx, NULL, vggt, photos, 1, &turns), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(turns.dino && !turns.vggt); // not the photos of the first call
    photos[1].height = 3;
    CHECK_RESULT(ctx, gsf_nn_encode_references(ctx, dino, NULL, photos, 2, &turns), GSF_ERROR_UNSUPPORTED);
    CHECK_RESULT(ctx, gsf_nn_encode_references(ctx, dino, NULL, photos, 0, &turns), GSF_ERROR_INVALID_ARGUMENT);
    photos[1].height = 5;
    photos[0].channels = 2;
    CHECK_RESULT(ctx, gsf_nn_encode_references(ctx, dino, NULL, photos, 2, &turns), GSF_ERROR_INVALID_ARGUMENT);
    photos[0].channels = 3;
    photos[0].width = 1; // the height is 518 times the width
    photos[0].height = 300;
    gsf_image image;
    CHECK_RESULT(ctx, gsf__nn_prepare_reference(ctx, &photos[0], &image), GSF_ERROR_UNSUPPORTED);
    gsf_nn_destroy_features(ctx, &both);
    gsf_nn_destroy_features(ctx, &turns);
    for (int i = 0; i < 2; i++) gsf_destroy_image(ctx, &photos[i]);
}

int main(void) {
    gsf_context ctx;
    gsf_nn_dinov2 dino;
    gsf_nn_vggt vggt;
    uint64_t seed = 11;
    test_context_zero(&ctx);
    ctx.threads = 1;
    if (gsf_init_context(&ctx) != GSF_OK) return 2;
    for (size_t i = 0; i < sizeof pixels / sizeof pixels[0]; i++) pixels[i] = (float)test_random(&seed);
    float *expected = (float*)malloc(ROOM * sizeof(float)), *out = (float*)malloc(ROOM * sizeof(float));
    if (!CHECK_OK(&ctx, gsf_nn_load_dinov2(&ctx, test_golden("encoders/dinov2_reg"), &dino)) ||
        !CHECK_OK(&ctx, gsf_nn_load_vggt(&ctx, test_golden("encoders/vggt"), &vggt)))
        return test_report();
    test_workers(&dino, &vggt, expected, out);
    test_encoders_bf16(&ctx, &dino, &vggt, expected, out);
    test_vggt_alone(&ctx, expected, out);
    test_groups(&ctx, &dino, out);
    test_cancel(&ctx, &vggt, out);
    test_bad_inputs(&ctx, &dino, &vggt, out);
    test_features(&ctx, &dino, &vggt);
    test_encoder_memory(out);
    test_bad_dinov2(&ctx);
    test_bad_vggt(&ctx);
    test_poison(&ctx, out);
    gsf_nn_destroy_dinov2(&ctx, &dino);
    gsf_nn_destroy_dinov2(&ctx, &dino); // destroying twice is allowed
    gsf_nn_destroy_vggt(&ctx, &vggt);
    free(expected);
    free(out);
    return test_report();
}
