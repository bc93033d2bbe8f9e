// bench/make_model.c, which makes restorer models with random weights: the same bytes for any number of
// shards and threads, the tensor lists of the released models, values that run, and vocabularies that encode their words.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#pragma push_macro("main")
#undef main
#define main make_model_main
#include "../bench/make_model.c"
#pragma pop_macro("main")

#include "test.h"
#include "test_hooks.h"

#define SINGLE "/diffusion_pytorch_model.safetensors" // of the diffusion model's parts; the encoders'
#define INDEX SINGLE ".index.json"
#define ENCODER "/model.safetensors"

typedef struct folder { char path[1000]; } folder;

static folder scratch(const char* name) {
    folder f;
    snprintf(f.path, sizeof f.path, "%s", test_scratch(name));
    return f;
}

static const char* inside(const folder* f, const char* name) { // static buffers, the last 4 stay valid
    static char paths[4][1100];
    static int turn;
    char* path = paths[turn++ & 3];
    snprintf(path, sizeof paths[0], "%s/%s", f->path, name);
    return path;
}

static model_options options(const folder* out, const char* size) {
    model_options o;
    memset(&o, 0, sizeof o);
    o.out = out->path;
    for (size_t i = 0; i < GSF__COUNT(model_sizes); i++)
        if (strcmp(model_sizes[i].name, size) == 0) o.size = &model_sizes[i];
    o.dtype = GSF_NN_BF16;
    o.seed = 7;
    o.shards = 1;
    o.parts = MODEL_ALL;
    return o;
}

static int same_file(const folder* a, const folder* b, const char* name) {
    size_t size_a, size_b;
    char *data_a = test_read_file(inside(a, name), &size_a), *data_b = test_read_file(inside(b, name), &size_b);
    const int same = size_a == size_b && memcmp(data_a, data_b, size_a) == 0;
    free(data_a);
    free(data_b);
    return same;
}

static int exists(const folder* f, const char* name) {
    FILE* file = fopen(inside(f, name), "rb");
    if (file) fclose(file);
    return file != NULL;
}

// Fraction of the values of b that equal those of a, over all tensors; -1 if names or shapes differ. narrow: a is rounded
// to bf16 first.
static double same_values(gsf_context* ctx, const folder* a, const folder* b, const char* name, int narrow) {
    gsf_nn_weights x, y;
    double same = 0.0, count = 0.0;
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, inside(a, name), NULL, &x))) return -1.0;
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, inside(b, name), NULL, &y))) return -1.0;
    int ok = x.tensor_count == y.tensor_count && x.tensor_count > 0;
    for (size_t i = 0; ok && i < x.tensor_count; i++) {
        const gsf_nn_tensor *s = &x.tensors[i], *t = &y.tensors[i];
        ok = strcmp(s->name, t->name) == 0 && s->rank == t->rank && memcmp(s->shape, t->shape, sizeof s->shape) == 0;
        for (int64_t k = 0; ok && k < s->count; k++) {
            float u, v;
            gsf_nn_convert_tensor(s, k, 1, &u);
            gsf_nn_convert_tensor(t, k, 1, &v);
            if (narrow) u = gsf__bf16_to_float(gsf__float_to_bf16(u));
            same += u == v;
        }
        count += (double)s->count;
    }
    gsf_nn_destroy_weights(ctx, &x);
    gsf_nn_destroy_weights(ctx, &y);
    return ok ? same / count : -1.0;
}

// ---- the same bytes ----------------------------------------------------------------

// Every file listed in the table of parts exists, with the weights in a single file.
static void check_same_parts(const folder* a, const folder* b) {
    for (size_t i = 0; i < MODEL_PARTS; i++) {
        const model_part* part = &model_parts[i];
        char name[200];
        for (size_t k = 0; k < GSF__COUNT(part->files) && part->files[k].name; k++) {
            snprintf(name, sizeof name, "%s/%s", part->folder, part->files[k].name);
            if (!CHECK(same_file(a, b, name))) fprintf(stderr, "    %s\n", name);
        }
        snprintf(name, sizeof name, "%s/%s.safetensors", part->folder, part->stem ? part->stem : "");
        if (part->stem && !CHECK(same_file(a, b, name))) fprintf(stderr, "    %s\n", name);
    }
    CHECK(same_file(a, b, "model_index.json"));
}

static void check_same_model(gsf_context* ctx) {
    static const char* const sharded_parts[] = {"transformer", "text_encoder", "blip2"};
    const folder first = scratch("first"), again = scratch("again"), other = scratch("other"), sharded = scratch("sharded");
    const folder wide = scratch("wide");
    model_report reports[MODEL_PARTS];
    model_options o = options(&first, "tiny");
    CHECK_OK(ctx, model_make(ctx, &o, reports));

    gsf_context three;
    memset(&three, 0, sizeof three);
    work_backwards(&three);
    CHECK_OK(&three, gsf_init_context(&three));
    o.out = again.path;
    o.shards = 3; // then one: the index must be removed
    o.parts = MODEL_TRANSFORMER | MODEL_TEXT | MODEL_BLIP2;
    CHECK_OK(&three, model_make(&three, &o, reports));
    CHECK(exists(&again, "transformer" INDEX) && exists(&again, "blip2" ENCODER ".index.json"));
    o.shards = 1;
    o.parts = MODEL_ALL;
    CHECK_OK(&three, model_make(&three, &o, reports));
    CHECK(!exists(&again, "transformer" INDEX) && !exists(&again, "blip2" ENCODER ".index.json"));
    check_same_parts(&first, &again);
    CHECK(!exists(&first, "transformer" SINGLE ".tmp"));

    o.out = sharded.path;
    o.shards = 3;
    o.parts = MODEL_TRANSFORMER | MODEL_VAE | MODEL_TEXT | MODEL_BLIP2;
    CHECK_OK(ctx, model_make(ctx, &o, reports));
    CHECK(!exists(&sharded, "transformer" SINGLE) && !exists(&sharded, "text_encoder" ENCODER));
    CHECK(exists(&sharded, "transformer/diffusion_pytorch_model-00003-of-00003.safetensors"));
    for (size_t i = 0; i < GSF__COUNT(sharded_parts); i++)
        CHECK(same_values(ctx, &first, &sharded, sharded_parts[i], 0) == 1.0);
    CHECK(same_file(&first, &sharded, "vae" SINGLE));

    o.out = wide.path;
    o.shards = 1;
    o.dtype = GSF_NN_F32;
    o.parts = MODEL_VAE; // this part only
    CHECK_OK(ctx, model_make(ctx, &o, reports));
    CHECK(!exists(&wide, "features.safetensors") && !exists(&wide, "text_encoder/config.json"));
    CHECK(!same_file(&first, &wide, "model_index.json")); // it does not list a text encoder
    CHECK(same_values(ctx, &wide, &first, "vae", 1) == 1.0);

    o.out = other.path;
    o.dtype = GSF_NN_F16;
    o.seed = 8;
    CHECK_OK(ctx, model_make(ctx, &o, reports));
    CHECK(same_values(ctx, &first, &other, "vae", 0) < 0.01);
}

// ---- lists of tensors ----------------------------------------------------------------

static double list_values(const model_list* list) {
    double values = 0.0;
    for (size_t i = 0; i < list->count; i++) values += (double)list->tensors[i].count;
    return values;
}

// Counts taken from the classes of diffusers and transformers.
static void check_full(gsf_context* ctx) {
    static const struct { size_t tensors; double values; } known[MODEL_PARTS] = {
        {1621, 7166167104.0 + 54607872.0}, {436, 215583907.0}, {0, 0.0}, {0, 0.0}, {440, 304372736.0}, {1210, 909112320.0},
        {219, 4762310656.0}, {0, 0.0}, {1247, 3744761856.0}};
    const folder none = scratch("none");
    const model_options o = options(&none, "full");
    for (size_t i = 0; i < MODEL_PARTS; i++) {
        model_list list;
        if (!known[i].tensors) continue;
        CHECK_OK(ctx, model_list_part(ctx, &model_parts[i], o.size, &list));
        if (!CHECK(list.count == known[i].tensors && list_values(&list) == known[i].values))
            fprintf(stderr, "    %s: %zu tensors, %.0f values\n", model_parts[i].folder, list.count, list_values(&list));
        gsf_free(ctx, list.tensors);
    }
}

static void check_list(model_list* list, const gsf_nn_weights* weights) {
    CHECK_OK(list->ctx, list->result);
    CHECK(list->count == weights->tensor_count);
    for (size_t i = 0; i < list->count; i++) {
        const gsf_nn_tensor* t = gsf_nn_find_tensor(weights, list->tensors[i].name);
        const int ok = t && t->rank == list->tensors[i].rank &&
                       memcmp(t->shape, list->tensors[i].shape, (size_t)t->rank * sizeof t->shape[0]) == 0;
        if (!CHECK(ok)) fprintf(stderr, "    %s\n", list->tensors[i].name);
    }
}

// Names and shapes of the golden models, which diffusers and transformers wrote.
#define CHECK_GOLDEN(net, path, add, source)                               \
    do {                                                                   \
        gsf_nn_##net net;                                                  \
        model_list list = model_begin_list(ctx, MODEL_ALL);                \
        if (CHECK_OK(ctx, gsf_nn_load_##net(ctx, test_golden(path), &net))) { \
            add(&list, source);                                            \
            check_list(&list, &net.weights);                               \
            gsf_nn_destroy_##net(ctx, &net);                               \
        }                                                                  \
        gsf_free(ctx, list.tensors);                                       \
    } while (0)

static void check_golden(gsf_context* ctx) {
    CHECK_GOLDEN(transformer, "restorer/model/transformer", model_add_transformer, &transformer);
    CHECK_GOLDEN(vae, "restorer/model/vae", model_add_vae, &vae);
    CHECK_GOLDEN(t5, "restorer/model/text_encoder", model_add_t5, &t5);
    CHECK_GOLDEN(dinov2, "encoders/dinov2_reg", model_add_dinov2, (const gsf__vit*)dinov2.nets);
    CHECK_GOLDEN(vggt, "encoders/vggt", model_add_vggt, (const gsf__vggt*)vggt.nets);
    CHECK_GOLDEN(captioner, "encoders/blip2", model_add_blip2, (const gsf__blip*)captioner.nets);
}

// ---- values that run -----------------------------------------------------------------

static double rms(const float* x, size_t count) { // NaN or infinite if a value is
    double sum = 0.0;
    for (size_t i = 0; i < count; i++) sum += (double)x[i] * (double)x[i];
    return sqrt(sum / (double)count);
}

static void check_rms(const char* what, const float* x, size_t count, double low, double high) {
    const double r = rms(x, count);
    if (getenv("GSF_TEST_VERBOSE")) printf("%-40s %.3g\n", what, r);
    if (!CHECK(r >= low && r <= high)) fprintf(stderr, "    rms of %s is %g, not %g to %g\n", what, r, low, high);
}

static float* made_noise(uint64_t seed, size_t count) {
    float* x = (float*)malloc(count * sizeof(float));
    for (size_t i = 0; i < count; i++) x[i] = (float)gsf_draw_normal(seed, 0, i);
    return x;
}

static int gates; // gate tensors seen
static void see_block(void* user, const char* name, int32_t row, const float* data, int64_t rows, int64_t columns) {
    (void)user;
    (void)row;
    const char* part = strchr(name, '.');
    if (strncmp(name, "block", 5) != 0 || !part) return;
    if (strcmp(part, ".norm1.2") == 0 || strcmp(part, ".norm1.3") == 0) {
        check_rms(name, data, (size_t)(rows * columns), 0.1, 0.4);
        gates++;
    } else if (strcmp(part, ".0") == 0) {
        check_rms(name, data, (size_t)(rows * columns), 0.5, 3.0);
    }
}

static void check_made_transformer(gsf_context* ctx, const folder* model) {
    gsf_nn_transformer net;
    gsf_nn_weights features;
    if (!CHECK_OK(ctx, gsf_nn_load_transformer(ctx, inside(model, "transformer"), &net))) return;
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, inside(model, "features.safetensors"), NULL, &features));
    const gsf_nn_tensor* dino = gsf_nn_find_tensor(&features, "dino_latents");
    const gsf_nn_tensor* vggt = gsf_nn_find_tensor(&features, "vggt_latents");
    const gsf_nn_tensor* text = gsf_nn_find_tensor(&features, "prompt_embeds");
    if (CHECK(dino && vggt && text)) {
        const int64_t tokens = dino->shape[0] * dino->shape[1], width = (int64_t)net.heads * net.head_dim;
        const int32_t frames = (net.sample_frames - 1) / net.temporal_ratio + 1;
        const size_t plane = (size_t)net.sample_height * (size_t)net.sample_width * (size_t)frames;
        const double steps[1] = {479.0};
        float* dino_values = (float*)malloc((size_t)dino->count * sizeof(float));
        float* vggt_values = (float*)malloc((size_t)vggt->count * sizeof(float));
        float* text_values = (float*)malloc((size_t)text->count * sizeof(float));
        float* references = (float*)malloc((size_t)(tokens * width) * sizeof(float));
        float* out = (float*)malloc(plane * (size_t)net.out_channels * sizeof(float));
        float* hidden = made_noise(5, plane * (size_t)net.in_channels);
        gsf_nn_convert_tensor(dino, 0, dino->count, dino_values);
        gsf_nn_convert_tensor(vggt, 0, vggt->count, vggt_values);
        gsf_nn_convert_tensor(text, 0, text->count, text_values);
        CHECK_OK(ctx, gsf_nn_project_references(ctx, &net, tokens, dino_values, vggt_values, references));
        gsf_nn_transformer_desc in;
        memset(&in, 0, sizeof in);
        in.batch = in.reference_batch = 1;
        in.frames = frames;
        in.height = net.sample_height;
        in.width = net.sample_width;
        in.hidden = hidden;
        in.text = text_values;
        in.timesteps = steps;
        in.references = references;
        in.reference_tokens = tokens;
        const gsf__nn_tap tap = {see_block, NULL};
        in._tap = &tap;
        CHECK_OK(ctx, gsf_nn_run_transformer(ctx, &net, &in, out));
        check_rms("velocity", out, plane * (size_t)net.out_channels, 0.5, 2.0);
        CHECK(gates == 2 * net.layers);
        free(dino_values);
        free(vggt_values);
        free(text_values);
        free(references);
        free(out);
        free(hidden);
    }
    gsf_nn_destroy_weights(ctx, &features);
    gsf_nn_destroy_transformer(ctx, &net);
}

static void check_made_vae(gsf_context* ctx, const folder* model) {
    gsf_nn_vae vae;
    gsf_nn_vae_info info, back;
    const int64_t frames = 9, height = 48, width = 40;
    if (!CHECK_OK(ctx, gsf_nn_load_vae(ctx, inside(model, "vae"), &vae))) return;
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, &vae, GSF_NN_VAE_ENCODE, NULL, frames, height, width, &info));
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, &vae, GSF_NN_VAE_DECODE, NULL, info.frames, info.height, info.width, &back));
    const size_t count = (size_t)(vae.latent_channels * info.frames * info.height * info.width);
    const size_t pixels = (size_t)(vae.out_channels * back.frames * back.height * back.width);
    float* video = made_noise(6, (size_t)(vae.in_channels * frames * height * width));
    float *mean = (float*)malloc(count * sizeof(float)), *decoded = (float*)malloc(pixels * sizeof(float));
    CHECK_OK(ctx, gsf_nn_encode_vae(ctx, &vae, NULL, video, frames, height, width, mean, NULL));
    check_rms("latents", mean, count, 0.2, 2.0);
    CHECK_OK(ctx, gsf_nn_decode_vae(ctx, &vae, NULL, mean, info.frames, info.height, info.width, decoded));
    check_rms("decoded", decoded, pixels, 0.2, 2.0);
    free(video);
    free(mean);
    free(decoded);
    gsf_nn_destroy_vae(ctx, &vae);
}

// The output of an encoder is not constant: its rows differ from each other.
static void check_made_rows(const char* what, const float* x, int64_t rows, int64_t columns) {
    double change = 0.0;
    check_rms(what, x, (size_t)(rows * columns), 0.5, 3.0);
    for (int64_t i = columns; i < rows * columns; i++) change += fabs((double)x[i] - (double)x[i - columns]);
    CHECK(change / (double)((rows - 1) * columns) > 0.1);
}

static void check_images(gsf_context* ctx, const folder* model) {
    enum { IMAGES = 2, TOKENS = 6, SIDE = 28, LONG_SIDE = 42, PIXELS = IMAGES * 3 * SIDE * LONG_SIDE };
    gsf_nn_dinov2 dinov2;
    gsf_nn_vggt vggt;
    gsf_nn_encoder_desc in;
    float* pixels = (float*)malloc(PIXELS * sizeof(float));
    for (size_t i = 0; i < PIXELS; i++) pixels[i] = (float)gsf_draw_uniform(9, 0, i);
    memset(&in, 0, sizeof in);
    in.pixels = pixels;
    in.images = IMAGES;
    in.height = SIDE;
    in.width = LONG_SIDE;
    if (CHECK_OK(ctx, gsf_nn_load_dinov2(ctx, inside(model, "dinov2"), &dinov2))) {
        float* out = (float*)malloc((size_t)(IMAGES * TOKENS * dinov2.width) * sizeof(float));
        CHECK(dinov2.width == 1024 && dinov2.layers == 1);
        CHECK_OK(ctx, gsf_nn_encode_dinov2(ctx, &dinov2, &in, out));
        check_made_rows("dinov2", out, IMAGES * TOKENS, dinov2.width);
        gsf_nn_destroy_dinov2(ctx, &dinov2);
        free(out);
    }
    if (CHECK_OK(ctx, gsf_nn_load_vggt(ctx, inside(model, "vggt"), &vggt))) {
        float* out = (float*)malloc((size_t)(IMAGES * TOKENS * 2 * vggt.width) * sizeof(float));
        CHECK(vggt.width == 1024 && vggt.layers == 1);
        CHECK_OK(ctx, gsf_nn_encode_vggt(ctx, &vggt, &in, out));
        check_made_rows("vggt", out, IMAGES * TOKENS, 2 * vggt.width);
        gsf_nn_destroy_vggt(ctx, &vggt);
        free(out);
    }
    free(pixels);
}

// A listed word is one piece, other text is encoded by characters, and no ASCII character is unknown.
static void check_text(gsf_context* ctx, const folder* model) {
    static const char sentence[] = "A red house by the river: 12% \"x\" <extra_id_0>";
    static const char* const pieces[] = {"", "A", " red", " house", " by", " the", " river", ":"};
    gsf_nn_tokenizer tokenizer;
    gsf_nn_t5 t5;
    gsf_nn_t5_desc in;
    int32_t ids[26];
    size_t count = 0;
    if (!CHECK_OK(ctx, gsf_nn_load_tokenizer(ctx, inside(model, "tokenizer"), &tokenizer))) return;
    CHECK(tokenizer.piece_count == MODEL_PIECES && tokenizer.id_count == MODEL_PIECES + 100);
    CHECK_OK(ctx, gsf_nn_encode_text(ctx, &tokenizer, sentence, strlen(sentence), ids, GSF__COUNT(ids), &count));
    CHECK(count == GSF__COUNT(pieces) + 10 && ids[count - 1] == 1 && ids[count - 2] == tokenizer.id_count - 1);
    CHECK(ids[0] == 3 && ids[1] == MODEL_PIECES - '~' - 1 + 'A'); // a space, then single characters
    for (size_t i = 2; i < 7; i++) {
        size_t word = 0;
        while (word < GSF__COUNT(model_words) && strcmp(model_words[word], pieces[i] + 1) != 0) word++;
        CHECK(ids[i] == 4 + (int32_t)word);
    }
    for (size_t i = 0; i < count; i++) CHECK(ids[i] != tokenizer.unknown_id);
    memset(&in, 0, sizeof in);
    in.ids = ids;
    in.batch = 1;
    in.tokens = (int32_t)count;
    if (CHECK_OK(ctx, gsf_nn_load_t5(ctx, inside(model, "text_encoder"), &t5))) {
        float* out = (float*)malloc(count * (size_t)t5.width * sizeof(float));
        CHECK(tokenizer.id_count <= t5.vocabulary);
        CHECK_OK(ctx, gsf_nn_encode_t5(ctx, &t5, &in, out));
        check_made_rows("text", out, (int64_t)count, t5.width);
        gsf_nn_destroy_t5(ctx, &t5);
        free(out);
    }
    gsf_nn_destroy_tokenizer(ctx, &tokenizer);
}

static void check_captions(gsf_context* ctx, const folder* model) {
    static const char sentence[] = "a red house";
    gsf_nn_captioner captioner;
    int32_t* ids = NULL;
    size_t count = 0;
    char captions[2][400];
    if (!CHECK_OK(ctx, gsf_nn_load_captioner(ctx, inside(model, "blip2"), &captioner))) return;
    CHECK(captioner.image_token == captioner.vocabulary - 1 && captioner.tokenizer.highest_id == captioner.image_token);
    CHECK_OK(ctx, gsf_nn_encode_bpe(ctx, &captioner.tokenizer, sentence, strlen(sentence), 1, &ids, &count));
    CHECK(count == 3 && ids[0] == MODEL_BYTE_0 + 'a' && ids[1] > MODEL_WORD_0); // "a", " red", " house"
    gsf_free(ctx, ids);
    for (int i = 0; i < 2; i++) {
        const char* path = test_golden(i ? "encoders/blip2/image1.png" : "encoders/blip2/image0.png");
        gsf_image image;
        captions[i][0] = 0;
        if (!CHECK_OK(ctx, gsf_load_image(ctx, path, 3, &image))) continue;
        CHECK_OK(ctx, gsf_nn_caption_image(ctx, &captioner, &image, NULL, 0, captions[i], sizeof captions[i]));
        if (getenv("GSF_TEST_VERBOSE")) printf("caption: %s\n", captions[i]);
        gsf_destroy_image(ctx, &image);
    }
    CHECK(strlen(captions[0]) > 20 && strcmp(captions[0], captions[1]) != 0);
    gsf_nn_destroy_captioner(ctx, &captioner);
}

static void check_runs(gsf_context* ctx) {
    const folder model = scratch("first");
    gsf_nn_dit_desc desc;
    gsf_restorer restorer;
    char path[2][1100];
    check_made_transformer(ctx, &model);
    check_made_vae(ctx, &model);
    check_images(ctx, &model);
    check_text(ctx, &model);
    check_captions(ctx, &model);
    memset(&desc, 0, sizeof desc);
    snprintf(path[0], sizeof path[0], "%s", model.path);
    snprintf(path[1], sizeof path[1], "%s", inside(&model, "features.safetensors"));
    desc.model = path[0];
    for (int i = 0; i < 2; i++, desc.features = path[1]) // with the encoders, then with their precomputed features
        if (CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &restorer))) gsf_destroy_restorer(ctx, &restorer);
}

// ---- errors ----------------------------------------------------------------------------

static int run(const char* a, const char* b, const char* c) {
    char text[4][1100];
    char* argv[5];
    const char* words[4] = {"make_model", a, b, c};
    int argc = 0;
    for (int i = 0; i < 4 && words[i]; i++) {
        snprintf(text[i], sizeof text[i], "%s", words[i]);
        argv[argc++] = text[i];
    }
    argv[argc] = NULL;
    return make_model_main(argc, argv);
}

static void check_errors(gsf_context* ctx) {
    const folder file = scratch("file"), program = scratch("program");
    model_report reports[MODEL_PARTS];
    model_options o = options(&file, "tiny");
    CHECK_OK(ctx, gsf_write_file(ctx, file.path, "x", 1));
    CHECK_RESULT(ctx, model_make(ctx, &o, reports), GSF_ERROR_IO);
    o.out = program.path;
    o.shards = 999;
    CHECK_RESULT(ctx, model_make(ctx, &o, reports), GSF_ERROR_INVALID_ARGUMENT);
    o.shards = 1;
    char left[1200]; // left by an earlier run of this test
    snprintf(left, sizeof left, "%s/transformer" SINGLE, program.path);
    remove(left);
    gsf_request_cancel(ctx);
    CHECK_RESULT(ctx, model_make(ctx, &o, reports), GSF_ERROR_CANCELLED);
    gsf_clear_cancel(ctx);
    CHECK(!exists(&program, "transformer" SINGLE) && !exists(&program, "transformer" SINGLE ".tmp"));

    CHECK(run(NULL, NULL, NULL) == 2);
    CHECK(run(program.path, "--size", "huge") == 2);
    CHECK(run(program.path, "--seed", "-1") == 2);
    CHECK(run(program.path, "--parts", "vae,") == 2);
    CHECK(run(program.path, "--shards", "0") == 2);
    CHECK(run(program.path, "--dtype", NULL) == 2);
    CHECK(run(file.path, "--size", "tiny") == 1);
    CHECK(run(program.path, "--parts", "text,features") == 0);
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    check_same_model(&ctx);
    check_full(&ctx);
    check_golden(&ctx);
    check_runs(&ctx);
    check_errors(&ctx);
    return test_report();
}
