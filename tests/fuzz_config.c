// fuzz_config.c - configurations of the networks and of the tokenizer. Build line: fuzz.h, with -DTEST_GOLDEN=
// '"tests/golden"'. The first byte selects the network, the rest is its configuration; the weights are those of the
// small golden model. Accepted models can run; refused ones give a one-line error.
#include "gsfixer_nn.h"

#include "fuzz.h"
#include "made_spiece.h"

#include <stdio.h>

enum { KINDS = 10, FILES = 12 };

static const struct kind { const char *folder, *config; } kinds[KINDS] = {
    {"restorer/model/transformer", "/config.json"},
    {"restorer/model/vae", "/config.json"},
    {"restorer/model/scheduler", "/scheduler_config.json"},
    {"restorer/model/text_encoder", "/config.json"},
    {"encoders/dinov2_reg", "/config.json"},
    {"encoders/vggt", "/config.json"},
    {"encoders/blip2", "/config.json"},
    {"encoders/blip2", "/preprocessor_config.json"},
    {"", "/tokenizer_config.json"},
    {"", "/added_tokens.json"}};

static float values[1 << 15], results[1 << 20]; // any input, any output
static int runs; // a forward pass takes as long as loading 100 times, so only one input in 64 (by hash) runs it

// Reads all the other files of the golden folder, once.
static void load_folder(const char* folder, fuzz_file* files) {
    static const char* const names[FILES] = {
        "/config.json", "/model.safetensors", "/model.safetensors.index.json", "/model-00001-of-00002.safetensors",
        "/model-00002-of-00002.safetensors", "/diffusion_pytorch_model.safetensors", "/vocab.json", "/merges.txt",
        "/preprocessor_config.json", "/tokenizer_config.json", "/special_tokens_map.json", "/added_tokens.json"};
    size_t count = 0;
    for (size_t i = 0; i < FILES; i++) {
        char path[1024];
        snprintf(path, sizeof path, "%s/%s%s", TEST_GOLDEN, folder, names[i]);
        FILE* file = fopen(path, "rb");
        if (!file) continue;
        FUZZ_CHECK(fseek(file, 0, SEEK_END) == 0);
        const size_t size = (size_t)ftell(file);
        char* data = (char*)malloc(size + 1);
        rewind(file);
        FUZZ_CHECK(data && fread(data, 1, size, file) == size);
        fclose(file);
        files[count].name = names[i];
        files[count].data = data;
        files[count++].size = size;
    }
}

// Lists the files of a kind's folder; the fuzzed config comes before the file of the same name.
static size_t fill_folder(size_t kind, fuzz_file* files) {
    static fuzz_file folders[KINDS][FILES + 1];
    static made_bytes spiece;
    size_t bytes = 0;
    if (kinds[kind].folder[0] && !folders[kind][0].name) load_folder(kinds[kind].folder, folders[kind]);
    memcpy(files, folders[kind], sizeof folders[kind]);
    if (!kinds[kind].folder[0]) {
        made_spiece(0, &spiece);
        files[0].name = "/spiece.model";
        files[0].data = spiece.data;
        files[0].size = spiece.size;
    }
    for (size_t i = 0; files[i].name; i++) bytes += files[i].size;
    return bytes;
}

static gsf_result use_transformer(gsf_context* ctx) {
    gsf_nn_transformer net;
    gsf_nn_transformer_desc in;
    const double time = 500.0;
    gsf_result result = gsf_nn_load_transformer(ctx, "fuzz", &net);
    if (result != GSF_OK) return result;
    memset(&in, 0, sizeof in);
    in.batch = in.frames = 1;
    in.height = net.sample_height, in.width = net.sample_width;
    in.hidden = values, in.text = values;
    in.text_tokens = net.text_tokens < 4 ? net.text_tokens : 4;
    in.timesteps = &time;
    const int64_t pixels = (int64_t)in.height * in.width;
    if (runs && pixels <= 400 && pixels * net.in_channels <= (1 << 15) && pixels * net.out_channels <= (1 << 15))
        result = gsf_nn_run_transformer(ctx, &net, &in, results);
    FUZZ_CHECK(result == GSF_OK || ctx->error[0] != 0);
    gsf_nn_destroy_transformer(ctx, &net);
    return GSF_OK;
}

static gsf_result use_vae(gsf_context* ctx) {
    gsf_nn_vae vae;
    gsf_nn_vae_info info;
    gsf_result result = gsf_nn_load_vae(ctx, "fuzz", &vae);
    if (result != GSF_OK) return result;
    FUZZ_CHECK(gsf_nn_query_vae(ctx, &vae, GSF_NN_VAE_DECODE, NULL, 2, 1, 1, &info) != GSF_OK ||
               (info.frames > 0 && info.height > 0 && info.width > 0));
    if (runs) result = gsf_nn_decode_vae(ctx, &vae, NULL, values, 2, 1, 1, results);
    FUZZ_CHECK(result == GSF_OK || ctx->error[0] != 0);
    gsf_nn_destroy_vae(ctx, &vae);
    return GSF_OK;
}

static gsf_result use_schedule(gsf_context* ctx) {
    gsf_nn_schedule schedule;
    gsf_nn_sampler sampler;
    gsf_nn_sampler_desc desc;
    memset(&desc, 0, sizeof desc);
    const gsf_result result = gsf_nn_load_schedule(ctx, "fuzz/scheduler_config.json", &schedule);
    if (result != GSF_OK) return result;
    const double* table = schedule.alpha_bar;
    const int32_t most = schedule.desc.train_steps;
    FUZZ_CHECK(most >= 2 && isfinite(schedule.final_alpha_bar) && isfinite(table[0]) && isfinite(table[most - 1]));
    desc.steps = 4;
    desc.value_count = 3;
    for (int solver = 0; solver < 3; solver++) {
        desc.solver = (gsf_nn_solver)solver;
        float x[3] = {0.5f, -1.0f, 0.0f};
        if (gsf_nn_make_sampler(ctx, &schedule, &desc, &sampler) == GSF_OK) {
            for (int32_t i = 0; i < sampler.count; i++) FUZZ_CHECK(sampler.timesteps[i] >= 0 && sampler.timesteps[i] < most);
            while (sampler.index < sampler.count && gsf_nn_step_sampler(ctx, &sampler, values, x, NULL) == GSF_OK) {}
        }
        gsf_nn_destroy_sampler(ctx, &sampler);
    }
    gsf_nn_destroy_schedule(ctx, &schedule);
    return GSF_OK;
}

static gsf_result use_t5(gsf_context* ctx) {
    static const int32_t ids[3] = {2, 1, 0};
    gsf_nn_t5 t5;
    gsf_nn_t5_desc in;
    gsf_result result = gsf_nn_load_t5(ctx, "fuzz", &t5);
    if (result != GSF_OK) return result;
    memset(&in, 0, sizeof in);
    in.ids = ids;
    in.batch = 1;
    in.tokens = 3;
    if (runs && t5.width <= (1 << 15)) result = gsf_nn_encode_t5(ctx, &t5, &in, results);
    FUZZ_CHECK(result == GSF_OK || ctx->error[0] != 0);
    gsf_nn_destroy_t5(ctx, &t5);
    return GSF_OK;
}

static gsf_nn_encoder_desc square(int32_t patch) { // 2 x 1 patches
    gsf_nn_encoder_desc in;
    memset(&in, 0, sizeof in);
    in.pixels = values;
    in.images = 1;
    in.height = 2 * patch;
    in.width = patch;
    return in;
}

static gsf_result use_dinov2(gsf_context* ctx) {
    gsf_nn_dinov2 net;
    gsf_result result = gsf_nn_load_dinov2(ctx, "fuzz", &net);
    if (result != GSF_OK) return result;
    const gsf_nn_encoder_desc in = square(net.patch);
    if (runs && net.patch <= 64 && net.channels <= 3 && net.width <= (1 << 15))
        result = gsf_nn_encode_dinov2(ctx, &net, &in, results);
    FUZZ_CHECK(result == GSF_OK || ctx->error[0] != 0);
    gsf_nn_destroy_dinov2(ctx, &net);
    return GSF_OK;
}

static gsf_result use_vggt(gsf_context* ctx) {
    gsf_nn_vggt net;
    gsf_result result = gsf_nn_load_vggt(ctx, "fuzz", &net);
    if (result != GSF_OK) return result;
    const gsf_nn_encoder_desc in = square(net.patch);
    if (runs && net.patch <= 64 && net.width <= (1 << 15)) result = gsf_nn_encode_vggt(ctx, &net, &in, results);
    FUZZ_CHECK(result == GSF_OK || ctx->error[0] != 0);
    gsf_nn_destroy_vggt(ctx, &net);
    return GSF_OK;
}

static gsf_result use_captioner(gsf_context* ctx) {
    static uint8_t pixels[12];
    const gsf_image photo = gsf_wrap_image(pixels, GSF_U8, 2, 2, 3);
    gsf_nn_captioner net;
    char text[32];
    gsf_result result = gsf_nn_load_captioner(ctx, "fuzz", &net);
    if (result != GSF_OK) return result;
    if (runs && net.image_size <= 64) result = gsf_nn_caption_image(ctx, &net, &photo, NULL, 1, text, sizeof text);
    FUZZ_CHECK(result == GSF_OK || ctx->error[0] != 0);
    gsf_nn_destroy_captioner(ctx, &net);
    return GSF_OK;
}

static gsf_result use_tokenizer(gsf_context* ctx) {
    static const char text[] = " ab <extra_id_1>A\tu[K] <pad>x</s>";
    gsf_nn_tokenizer net;
    int32_t ids[64];
    size_t count;
    const gsf_result result = gsf_nn_load_tokenizer(ctx, "fuzz", &net);
    if (result != GSF_OK) return result;
    FUZZ_CHECK(gsf_nn_encode_text(ctx, &net, text, sizeof text - 1, ids, 64, &count) == GSF_OK && count <= 64);
    for (size_t i = 0; i < count; i++) FUZZ_CHECK(ids[i] >= 0 && ids[i] < net.id_count);
    gsf_nn_destroy_tokenizer(ctx, &net);
    return GSF_OK;
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    static gsf_result (*const use[KINDS])(gsf_context*) = {
        use_transformer, use_vae,       use_schedule,  use_t5,        use_dinov2,
        use_vggt,        use_captioner, use_captioner, use_tokenizer, use_tokenizer};
    fuzz_file files[1 + FILES + 1];
    if (size < 1) return 0;
    const size_t kind = data[0] % KINDS;
    uint32_t hash = 2166136261u; // FNV-1a
    for (size_t i = 0; i < size; i++) hash = (hash ^ data[i]) * 16777619u;
    runs = hash >> 26 == 0;
    gsf_context ctx = fuzz_context(size);
    fuzz_limit += 3 * fill_folder(kind, files + 1) + ((size_t)16 << 20); // weights, a pass, a schedule of a million steps
    files[0].name = kinds[kind].config;
    files[0].data = data + 1;
    files[0].size = size - 1;
    fuzz_hook_files(&ctx, files);
    const gsf_result result = use[kind](&ctx);
    if (result != GSF_OK) {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED || result == GSF_ERROR_INVALID_ARGUMENT);
        FUZZ_CHECK(ctx.error[0] != 0);
        fuzz_check_error(&ctx, "");
    }
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
