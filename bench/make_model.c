// make_model.c - a restorer model of seeded random weights in the official release's layout, at its size or smaller, for
// benches and tests of speed, memory and plumbing. What it restores is noise.
// By hand: cc -O2 -fopenmp -I. bench/make_model.c -o make_model -lm
//
//     make_model OUT [--size tiny|small|full] [--dtype f32|bf16|f16] [--seed S] [--shards N] [--threads N]
//                    [--parts transformer,vae,scheduler,features]
//
// Defaults: small, bf16, seed 0, one file, all parts. `full` has the release's configuration: 14.9 GB as bf16, of which
// never more than one block of values is in memory. OUT gets
//     transformer/{config.json, diffusion_pytorch_model*.safetensors}      with N > 1 shards and their index
//     vae/{config.json, diffusion_pytorch_model.safetensors}
//     scheduler/scheduler_config.json, model_index.json
//     features.safetensors    dino_latents (2, tokens, 1024), vggt_latents (2, tokens, 2048): two reference images;
//                             prompt_embeds (2, text tokens, text channels): negative and positive
// A value depends on seed, tensor and place only: not on shards, threads or other parts, and a narrow type's are those of
// f32 rounded. Each file is written beside its place and renamed.
#define GSFIXER_IMPLEMENTATION
#include "../gsfixer_nn.h"

#include <errno.h>
#include <signal.h>
#include <time.h>
#if defined(_WIN32)
#include <direct.h>
#define model_mkdir(path) _mkdir(path)
#else
#include <sys/stat.h>
#define model_mkdir(path) mkdir(path, 0777)
#endif

// ---- sizes and configurations ----------------------------------------------------

typedef struct model_size {
    const char* name;
    int heads, layers, time_channels, text_channels, text_tokens; // heads of 64
    int sample_height, sample_width, frames;                      // latents; video frames
    int reference_tokens;                                         // of one image
    int channels[4], vae_layers, vae_groups;
    int vae_height, vae_width; // pixels; multiples of 96 and 80, so that tiles overlap by whole latents
} model_size;

static const model_size model_sizes[] = {
    {"tiny", 2, 2, 64, 64, 26, 8, 12, 9, 8, {8, 16, 16, 24}, 1, 4, 96, 80},
    {"small", 8, 6, 256, 512, 64, 16, 24, 17, 70, {32, 64, 64, 128}, 2, 8, 192, 240},
    {"full", 48, 42, 512, 4096, 226, 60, 90, 49, 925, {128, 256, 256, 512}, 3, 32, 480, 720},
};

enum { MODEL_DINO_CHANNELS = 1024, MODEL_VGGT_CHANNELS = 2048 };

static void model_print_transformer(gsf_context* ctx, const model_size* s, gsf_text* out) {
    gsf_text_printf(ctx, out,
                    "{\n  \"_class_name\": \"CogVideoXCrossTransformer3DModel\",\n  \"_diffusers_version\": \"0.32.1\",\n"
                    "  \"activation_fn\": \"gelu-approximate\",\n  \"attention_bias\": true,\n"
                    "  \"attention_head_dim\": 64,\n  \"dropout\": 0.0,\n  \"flip_sin_to_cos\": true,\n"
                    "  \"freq_shift\": 0,\n  \"in_channels\": 32,\n  \"max_text_seq_length\": %d,\n"
                    "  \"norm_elementwise_affine\": true,\n  \"norm_eps\": 1e-05,\n  \"num_attention_heads\": %d,\n"
                    "  \"num_layers\": %d,\n  \"ofs_embed_dim\": null,\n  \"out_channels\": 16,\n"
                    "  \"patch_bias\": true,\n  \"patch_size\": 2,\n  \"patch_size_t\": null,\n",
                    s->text_tokens, s->heads, s->layers);
    gsf_text_printf(ctx, out,
                    "  \"sample_frames\": %d,\n  \"sample_height\": %d,\n  \"sample_width\": %d,\n"
                    "  \"spatial_interpolation_scale\": 1.875,\n  \"temporal_compression_ratio\": 4,\n"
                    "  \"temporal_interpolation_scale\": 1.0,\n  \"text_embed_dim\": %d,\n  \"time_embed_dim\": %d,\n"
                    "  \"timestep_activation_fn\": \"silu\",\n  \"use_learned_positional_embeddings\": true,\n"
                    "  \"use_rotary_positional_embeddings\": true\n}\n",
                    s->frames, s->sample_height, s->sample_width, s->text_channels, s->time_channels);
}

static void model_print_vae(gsf_context* ctx, const model_size* s, gsf_text* out) {
    gsf_text_printf(ctx, out,
                    "{\n  \"_class_name\": \"AutoencoderKLCogVideoX\",\n  \"_diffusers_version\": \"0.32.1\",\n"
                    "  \"act_fn\": \"silu\",\n  \"block_out_channels\": [\n    %d,\n    %d,\n    %d,\n    %d\n  ],\n",
                    s->channels[0], s->channels[1], s->channels[2], s->channels[3]);
    for (int up = 0; up < 2; up++) {
        const char* way = up ? "Up" : "Down";
        if (up)
            gsf_text_printf(ctx, out,
                            "  \"force_upcast\": true,\n  \"in_channels\": 3,\n  \"invert_scale_latents\": false,\n"
                            "  \"latent_channels\": 16,\n  \"latents_mean\": null,\n  \"latents_std\": null,\n"
                            "  \"layers_per_block\": %d,\n  \"norm_eps\": 1e-06,\n  \"norm_num_groups\": %d,\n"
                            "  \"out_channels\": 3,\n  \"sample_height\": %d,\n  \"sample_width\": %d,\n"
                            "  \"scaling_factor\": 0.7,\n  \"shift_factor\": null,\n"
                            "  \"temporal_compression_ratio\": 4,\n",
                            s->vae_layers, s->vae_groups, s->vae_height, s->vae_width);
        gsf_text_printf(ctx, out, "  \"%s_block_types\": [\n", up ? "up" : "down");
        for (int i = 0; i < 4; i++) gsf_text_printf(ctx, out, "    \"CogVideoX%sBlock3D\"%s\n", way, i < 3 ? "," : "");
        gsf_text_printf(ctx, out, "  ],\n");
    }
    gsf_text_printf(ctx, out, "  \"use_post_quant_conv\": false,\n  \"use_quant_conv\": false\n}\n");
}

static const char model_scheduler[] =
    "{\n  \"_class_name\": \"CogVideoXDDIMScheduler\",\n  \"_diffusers_version\": \"0.32.1\",\n  \"beta_end\": 0.012,\n"
    "  \"beta_schedule\": \"scaled_linear\",\n  \"beta_start\": 0.00085,\n  \"clip_sample\": false,\n"
    "  \"clip_sample_range\": 1.0,\n  \"num_train_timesteps\": 1000,\n  \"prediction_type\": \"v_prediction\",\n"
    "  \"rescale_betas_zero_snr\": true,\n  \"sample_max_value\": 1.0,\n  \"set_alpha_to_one\": true,\n"
    "  \"snr_shift_scale\": 1.0,\n  \"steps_offset\": 0,\n  \"timestep_spacing\": \"trailing\",\n"
    "  \"trained_betas\": null\n}\n";

// Text encoder and tokenizer are left out, which diffusers writes as two nulls: features.safetensors has the embeddings.
static const char model_index[] =
    "{\n  \"_class_name\": \"CogVideoXImageToVideoPipeline\",\n  \"_diffusers_version\": \"0.32.1\",\n"
    "  \"scheduler\": [\n    \"diffusers\",\n    \"CogVideoXDDIMScheduler\"\n  ],\n"
    "  \"text_encoder\": [\n    null,\n    null\n  ],\n  \"tokenizer\": [\n    null,\n    null\n  ],\n"
    "  \"transformer\": [\n    \"diffusers\",\n    \"CogVideoXTransformer3DModel\"\n  ],\n"
    "  \"vae\": [\n    \"diffusers\",\n    \"AutoencoderKLCogVideoX\"\n  ]\n}\n";

// ---- the lists of tensors --------------------------------------------------------

typedef struct model_tensor {
    char name[104];
    int64_t shape[5], count;
    int32_t rank, shard;
    uint64_t stream;       // of its random numbers
    double middle, spread; // values are uniform in middle - spread .. middle + spread
} model_tensor;

typedef struct model_list {
    gsf_context* ctx;
    model_tensor* tensors;
    size_t count, capacity;
    uint64_t stream; // of the first one
    gsf_result result;
} model_list;

enum { MODEL_TRANSFORMER = 1, MODEL_VAE = 2, MODEL_SCHEDULER = 4, MODEL_FEATURES = 8, MODEL_ALL = 15 };

static model_list model_begin_list(gsf_context* ctx, unsigned part) {
    model_list list;
    memset(&list, 0, sizeof list);
    list.ctx = ctx;
    list.stream = (uint64_t)part << 32;
    return list;
}

static int model_ends_in(const char* text, const char* end) {
    const size_t size = strlen(text), tail = strlen(end);
    return size >= tail && strcmp(text + size - tail, end) == 0;
}

// Every layer keeps the size of what goes through it: weights of variance 1 / fan-in, norms near 1. So the modulations and
// gates of the transformer's blocks come out about 0.2 in size, from the time embedding's own size.
static void model_choose_range(model_tensor* t) {
    const int64_t fan_in = t->count / t->shape[0];
    const int norm = t->rank == 1 && model_ends_in(t->name, ".weight");
    t->middle = norm || model_ends_in(t->name, ".conv_y.conv.bias") ? 1.0 : 0.0; // conv_y: a factor, too
    t->spread = norm ? 0.1 : t->rank == 1 ? 0.05 : sqrt(3.0 / (double)fan_in);
    if (model_ends_in(t->name, ".conv_y.conv.weight")) t->spread *= 0.25;
    if (model_ends_in(t->name, ".pos_embedding")) t->spread = 0.05;
    if (model_ends_in(t->name, "_latents") || model_ends_in(t->name, "_embeds")) t->spread = sqrt(3.0);
}

static void model_add(model_list* list, int32_t rank, const int64_t* shape, const char* prefix, const char* name) {
    if (list->result == GSF_OK)
        list->result = gsf__reserve(list->ctx, (void**)&list->tensors, &list->capacity, list->count, list->count + 1,
                                    sizeof *list->tensors);
    if (list->result != GSF_OK) return;
    model_tensor* t = &list->tensors[list->count];
    memset(t, 0, sizeof *t);
    const int length = snprintf(t->name, sizeof t->name, "%s%s", prefix, name);
    if (length < 0 || (size_t)length >= sizeof t->name) {
        list->result = gsf_fail(list->ctx, GSF_ERROR_INVALID_ARGUMENT, "the name %s%s is too long", prefix, name);
        return;
    }
    t->rank = rank;
    t->count = 1;
    for (int32_t i = 0; i < rank; i++) t->count *= t->shape[i] = shape[i];
    t->stream = list->stream + list->count++;
    model_choose_range(t);
}

// The tables by which the transformer is opened have every name and shape.
static void model_add_entries(model_list* list, const gsf_nn_transformer* c, const gsf__dit_entry* entries, size_t count,
                              const char* prefix) {
    for (size_t i = 0; i < count; i++) {
        int64_t shape[5];
        int32_t rank = 0;
        for (const char* s = entries[i].shape; *s && rank < 5; s++) {
            int64_t size = gsf__dit_dimension(c, *s);
            if (size < 0) size = strstr(entries[i].name, "dino") ? c->dino_channels : c->vggt_channels;
            shape[rank++] = size;
        }
        if (entries[i].kind == GSF__DIT_ATTENTION_BIAS && !c->attention_bias) continue;
        if (entries[i].kind == GSF__DIT_LEARNED && !c->learned_positions) continue;
        model_add(list, rank, shape, prefix, entries[i].name);
    }
}

static void model_list_transformer(model_list* list, const gsf_nn_transformer* c) {
    char prefix[48];
    model_add_entries(list, c, gsf__dit_entries, GSF__COUNT(gsf__dit_entries), "");
    for (int32_t i = 0; i < c->layers; i++) {
        snprintf(prefix, sizeof prefix, "transformer_blocks.%d.", (int)i);
        model_add_entries(list, c, gsf__dit_block_entries, GSF__COUNT(gsf__dit_block_entries), prefix);
    }
}

// The autoencoder is opened by a walk, not by a table; this is the same walk. Opening the model afterwards compares them.
static void model_add_conv(model_list* list, const char* prefix, const char* name, int64_t in, int64_t out, int64_t kt,
                           int64_t kernel) { // kt 0: a 2D layer
    char full[96];
    const int64_t flat[4] = {out, in, kernel, kernel}, deep[5] = {out, in, kt, kernel, kernel};
    snprintf(full, sizeof full, "%s%s", prefix, name);
    model_add(list, kt ? 5 : 4, kt ? deep : flat, full, ".weight");
    model_add(list, 1, &out, full, ".bias");
}

static void model_add_norm(model_list* list, const char* prefix, const char* name, int64_t channels, int64_t latents) {
    char full[96];
    snprintf(full, sizeof full, "%s%s%s", prefix, name, latents ? ".norm_layer" : ""); // latents > 0: the decoder's
    model_add(list, 1, &channels, full, ".weight");
    model_add(list, 1, &channels, full, ".bias");
    if (!latents) return;
    snprintf(full, sizeof full, "%s%s", prefix, name);
    model_add_conv(list, full, ".conv_y.conv", latents, channels, 1, 1);
    model_add_conv(list, full, ".conv_b.conv", latents, channels, 1, 1);
}

static void model_add_resnets(model_list* list, const char* block, int64_t in, int64_t out, int32_t count,
                              int64_t latents) {
    char name[80];
    for (int32_t i = 0; i < count; i++, in = out) {
        snprintf(name, sizeof name, "%s.resnets.%d", block, (int)i);
        model_add_norm(list, name, ".norm1", in, latents);
        model_add_conv(list, name, ".conv1.conv", in, out, 3, 3);
        model_add_norm(list, name, ".norm2", out, latents);
        model_add_conv(list, name, ".conv2.conv", out, out, 3, 3);
        if (in != out) model_add_conv(list, name, ".conv_shortcut", in, out, 1, 1);
    }
}

static void model_add_coder(model_list* list, const gsf_nn_vae* vae, int decoder) {
    const char *side = decoder ? "decoder" : "encoder", *way = decoder ? "up" : "down";
    const int64_t latents = decoder ? vae->latent_channels : 0;
    const int32_t last = vae->levels - 1;
    const int64_t coarse = vae->channels[last];
    int64_t in = decoder ? coarse : vae->channels[0];
    char name[64];
    model_add_conv(list, side, ".conv_in.conv", decoder ? vae->latent_channels : vae->in_channels, in, 3, 3);
    for (int32_t i = 0; i <= last; i++) {
        const int64_t out = vae->channels[decoder ? last - i : i];
        snprintf(name, sizeof name, "%s.%s_blocks.%d", side, way, (int)i);
        model_add_resnets(list, name, in, out, vae->layers_per_block + decoder, latents);
        snprintf(name, sizeof name, "%s.%s_blocks.%d.%ssamplers.0.conv", side, way, (int)i, way);
        if (i < last) model_add_conv(list, name, "", out, out, 0, 3);
        in = out;
    }
    snprintf(name, sizeof name, "%s.mid_block", side);
    model_add_resnets(list, name, coarse, coarse, 2, latents);
    model_add_norm(list, side, ".norm_out", in, latents);
    model_add_conv(list, side, ".conv_out.conv", in, decoder ? vae->out_channels : 2 * vae->latent_channels, 3, 3);
}

static void model_list_vae(model_list* list, const gsf_nn_vae* vae) {
    model_add_coder(list, vae, 0);
    model_add_coder(list, vae, 1);
}

static void model_list_features(model_list* list, const model_size* s) {
    const int64_t dino[3] = {2, s->reference_tokens, MODEL_DINO_CHANNELS};
    const int64_t vggt[3] = {2, s->reference_tokens, MODEL_VGGT_CHANNELS};
    const int64_t text[3] = {2, s->text_tokens, s->text_channels};
    model_add(list, 3, dino, "", "dino_latents");
    model_add(list, 3, vggt, "", "vggt_latents");
    model_add(list, 3, text, "", "prompt_embeds");
}

// ---- values ----------------------------------------------------------------------

GSF__BEGIN_IMPLEMENTATION // gcc inlines the library's functions only where its rounding mode holds, too

// Values made in one go; by one worker; by all. Each is a multiple of the one before.
enum { MODEL_BATCH = 256, MODEL_CHUNK = 1 << 15, MODEL_BLOCK = 1 << 20 };

typedef struct model_fill {
    const model_tensor* tensor;
    uint64_t seed;
    gsf_nn_dtype dtype;
    int64_t first, count; // values of the tensor
    unsigned char* out;
} model_fill;

// Four values from each random word; a batch at a time, in loops that compilers turn into vectors.
static void model_fill_batch(const model_fill* f, int64_t first, unsigned char out[4 * MODEL_BATCH]) {
    const float middle = (float)f->tensor->middle, step = (float)(f->tensor->spread / 32768.0);
    uint64_t words[MODEL_BATCH / 4];
    uint16_t bits[MODEL_BATCH], narrow[MODEL_BATCH];
    float values[MODEL_BATCH];
    for (int i = 0; i < MODEL_BATCH / 4; i++)
        words[i] = gsf_random_bits(f->seed, f->tensor->stream, (uint64_t)first / 4 + (uint64_t)i);
    memcpy(bits, words, sizeof bits);
    for (int i = 0; i < MODEL_BATCH; i++) values[i] = middle + step * ((float)(int32_t)bits[i] - 32767.5f);
    if (f->dtype == GSF_NN_F32) {
        memcpy(out, values, sizeof values);
        return;
    }
    if (f->dtype == GSF_NN_BF16)
        for (int i = 0; i < MODEL_BATCH; i++) narrow[i] = gsf__float_to_bf16(values[i]);
    else
        for (int i = 0; i < MODEL_BATCH; i++) narrow[i] = gsf__float_to_half(values[i]);
    memcpy(out, narrow, sizeof narrow);
}

static void model_fill_chunk(void* arg, size_t chunk, int worker) {
    const model_fill* f = (const model_fill*)arg;
    const int64_t begin = (int64_t)chunk * MODEL_CHUNK;
    const int64_t end = begin + MODEL_CHUNK < f->count ? begin + MODEL_CHUNK : f->count;
    const size_t size = gsf_nn_dtype_size(f->dtype);
    unsigned char batch[4 * MODEL_BATCH];
    (void)worker;
    for (int64_t i = begin; i < end; i += MODEL_BATCH) {
        model_fill_batch(f, f->first + i, batch);
        memcpy(f->out + (size_t)i * size, batch, (size_t)(end - i < MODEL_BATCH ? end - i : MODEL_BATCH) * size);
    }
}

GSF__END_IMPLEMENTATION

// ---- files -----------------------------------------------------------------------

typedef struct model_options {
    const char* out;
    const model_size* size;
    gsf_nn_dtype dtype;
    uint64_t seed;
    int shards;
    unsigned parts;
} model_options;

#define MODEL_STEM "diffusion_pytorch_model" // of the files of weights
#define MODEL_SINGLE MODEL_STEM ".safetensors"
#define MODEL_INDEX MODEL_SINGLE ".index.json"

typedef struct model_writer {
    gsf_context* ctx;
    const model_options* options;
    const char* part;     // for the progress
    unsigned char* block; // MODEL_BLOCK values
    double done, total;   // bytes
} model_writer;

static double model_bytes(const model_writer* w, const model_tensor* t) {
    return (double)t->count * (double)gsf_nn_dtype_size(w->options->dtype);
}

static int model_compare_names(const void* a, const void* b) {
    return strcmp((*(const model_tensor* const*)a)->name, (*(const model_tensor* const*)b)->name);
}

static gsf_result model_format_header(const model_writer* w, const model_tensor* const* tensors, size_t count,
                                      gsf_text* out) {
    const gsf_nn_dtype dtype = w->options->dtype;
    long long begin = 0;
    gsf_text_append(w->ctx, out, "        ", GSF__NN_FILE_HEAD); // for the length
    gsf_text_printf(w->ctx, out, "{\"__metadata__\":{\"format\":\"pt\"}");
    for (size_t i = 0; i < count; i++) {
        const long long end = begin + (long long)tensors[i]->count * (long long)gsf_nn_dtype_size(dtype);
        gsf_text_printf(w->ctx, out, ",\"%s\":{\"dtype\":\"%s\",\"shape\":[", tensors[i]->name, gsf_nn_dtype_name(dtype));
        for (int32_t k = 0; k < tensors[i]->rank; k++)
            gsf_text_printf(w->ctx, out, "%s%lld", k ? "," : "", (long long)tensors[i]->shape[k]);
        gsf_text_printf(w->ctx, out, "],\"data_offsets\":[%lld,%lld]}", begin, end);
        begin = end;
    }
    gsf_text_append(w->ctx, out, "}", 1);
    gsf_text_append(w->ctx, out, "       ", (8 - out->size % 8) % 8);
    if (out->failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__store_le(out->data, out->size - GSF__NN_FILE_HEAD, GSF__NN_FILE_HEAD);
    return GSF_OK;
}

static gsf_result model_write_bytes(model_writer* w, FILE* file, const char* path, const void* data, size_t size) {
    errno = 0;
    if (fwrite(data, 1, size, file) == size) return GSF_OK;
    return gsf_fail(w->ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, strerror(errno));
}

static gsf_result model_write_tensor(model_writer* w, FILE* file, const char* path, const model_tensor* tensor) {
    model_fill fill = {tensor, w->options->seed, w->options->dtype, 0, 0, w->block};
    const size_t size = gsf_nn_dtype_size(fill.dtype);
    for (; fill.first < tensor->count; fill.first += fill.count) {
        GSF__TRY(gsf__check_cancel(w->ctx));
        fill.count = tensor->count - fill.first < MODEL_BLOCK ? tensor->count - fill.first : MODEL_BLOCK;
        gsf__parallel_for(w->ctx, (size_t)((fill.count + MODEL_CHUNK - 1) / MODEL_CHUNK), model_fill_chunk, &fill);
        GSF__TRY(model_write_bytes(w, file, path, w->block, (size_t)fill.count * size));
        w->done += (double)fill.count * (double)size;
        gsf__progress(w->ctx, w->part, w->done, w->total);
    }
    return GSF_OK;
}

static gsf_result model_write_open_file(model_writer* w, FILE* file, const char* path,
                                        const model_tensor* const* tensors, size_t count) {
    gsf_text header;
    memset(&header, 0, sizeof header);
    gsf_result result = model_format_header(w, tensors, count, &header);
    if (result == GSF_OK) result = model_write_bytes(w, file, path, header.data, header.size);
    gsf_destroy_text(w->ctx, &header);
    for (size_t i = 0; i < count && result == GSF_OK; i++) result = model_write_tensor(w, file, path, tensors[i]);
    return result;
}

// One safetensors file of these tensors, in the order of their names as the official writer has it.
static gsf_result model_write_file(model_writer* w, const char* path, const model_tensor** tensors, size_t count) {
    gsf_text temporary;
    memset(&temporary, 0, sizeof temporary);
    gsf_text_printf(w->ctx, &temporary, "%s.tmp", path);
    if (temporary.failed) return GSF_ERROR_OUT_OF_MEMORY;
    qsort((void*)tensors, count, sizeof *tensors, model_compare_names);
    gsf_result result = GSF_OK;
    FILE* file = fopen(temporary.data, "wb");
    if (!file) {
        result = gsf_fail(w->ctx, GSF_ERROR_IO, "%s: %s", temporary.data, strerror(errno));
    } else {
        result = model_write_open_file(w, file, path, tensors, count);
        errno = 0;
        int ok = fclose(file) == 0;
#ifdef _WIN32 // rename does not replace there
        if (ok && result == GSF_OK) remove(path);
#endif
        if (ok && result == GSF_OK) ok = rename(temporary.data, path) == 0;
        if (!ok && result == GSF_OK)
            result = gsf_fail(w->ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, strerror(errno));
        if (result != GSF_OK) remove(temporary.data);
    }
    gsf_destroy_text(w->ctx, &temporary);
    return result;
}

// Consecutive tensors with about the same bytes in each shard, and no shard without a tensor.
static void model_deal(const model_writer* w, model_list* list, int shards) {
    double before = 0.0;
    int shard = 0;
    for (size_t i = 0; i < list->count; i++) {
        const int left = shards - 1 - shard; // still to begin
        if (i && left > 0 && (before * shards >= w->total * (shard + 1) || list->count - i == (size_t)left)) shard++;
        list->tensors[i].shard = shard;
        before += model_bytes(w, &list->tensors[i]);
    }
}

static void model_print_shard(gsf_context* ctx, gsf_text* out, int shard, int shards) {
    gsf_text_printf(ctx, out, MODEL_STEM "-%05d-of-%05d.safetensors", shard + 1, shards);
}

static gsf_result model_write_text(gsf_context* ctx, const char* folder, const char* name, const char* data, size_t size) {
    gsf_text path;
    memset(&path, 0, sizeof path);
    gsf_text_printf(ctx, &path, "%s/%s", folder, name);
    const gsf_result result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path.data, data, size);
    gsf_destroy_text(ctx, &path);
    return result;
}

static gsf_result model_write_index(const model_writer* w, const char* folder, const model_tensor** sorted, size_t count,
                                    int shards) {
    gsf_text out;
    memset(&out, 0, sizeof out);
    gsf_text_printf(w->ctx, &out, "{\n  \"metadata\": {\n    \"total_size\": %.0f\n  },\n  \"weight_map\": {\n", w->total);
    for (size_t i = 0; i < count; i++) {
        gsf_text_printf(w->ctx, &out, "    \"%s\": \"", sorted[i]->name);
        model_print_shard(w->ctx, &out, sorted[i]->shard, shards);
        gsf_text_printf(w->ctx, &out, "\"%s\n", i + 1 < count ? "," : "");
    }
    gsf_text_printf(w->ctx, &out, "  }\n}\n");
    const gsf_result result =
        out.failed ? GSF_ERROR_OUT_OF_MEMORY : model_write_text(w->ctx, folder, MODEL_INDEX, out.data, out.size);
    gsf_destroy_text(w->ctx, &out);
    return result;
}

static void model_remove(gsf_context* ctx, const char* folder, const char* name) {
    gsf_text path;
    memset(&path, 0, sizeof path);
    gsf_text_printf(ctx, &path, "%s/%s", folder, name);
    if (!path.failed) remove(path.data);
    gsf_destroy_text(ctx, &path);
}

// The files of a list: one called `single`, or shards with their index. What would be opened before them goes.
static gsf_result model_write_shards(model_writer* w, const char* folder, const char* single, model_list* list,
                                     int shards) {
    const model_tensor** picked = (const model_tensor**)gsf_alloc(w->ctx, list->count, sizeof *picked);
    gsf_result result = picked ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (int shard = 0; shard < shards && result == GSF_OK; shard++) {
        gsf_text path;
        size_t count = 0;
        memset(&path, 0, sizeof path);
        gsf_text_printf(w->ctx, &path, "%s/", folder);
        if (shards > 1) model_print_shard(w->ctx, &path, shard, shards);
        else gsf_text_printf(w->ctx, &path, "%s", single);
        for (size_t i = 0; i < list->count; i++)
            if (list->tensors[i].shard == shard) picked[count++] = &list->tensors[i];
        result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : model_write_file(w, path.data, picked, count);
        gsf_destroy_text(w->ctx, &path);
    }
    if (result == GSF_OK && shards > 1) {
        for (size_t i = 0; i < list->count; i++) picked[i] = &list->tensors[i];
        qsort((void*)picked, list->count, sizeof *picked, model_compare_names);
        result = model_write_index(w, folder, picked, list->count, shards);
    }
    if (result == GSF_OK) model_remove(w->ctx, folder, shards > 1 ? single : MODEL_INDEX);
    gsf_free(w->ctx, (void*)picked);
    return result;
}

// ---- the parts -------------------------------------------------------------------

static double model_now(void) {
    struct timespec t;
    timespec_get(&t, TIME_UTC);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static gsf_result model_make_folder(gsf_context* ctx, const char* path) {
    if (model_mkdir(path) == 0 || errno == EEXIST) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
}

typedef struct model_report { // of one part
    const char* part;
    size_t tensors;
    double values, bytes, seconds; // bytes of the values alone
} model_report;

static gsf_result model_write_list(gsf_context* ctx, const model_options* o, const char* folder, const char* single,
                                   model_list* list, int shards, model_report* report) {
    model_writer w;
    const double start = model_now();
    memset(&w, 0, sizeof w);
    w.ctx = ctx;
    w.options = o;
    w.part = report->part;
    GSF__TRY(list->result);
    if ((size_t)shards > list->count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%d shards for %zu tensors", shards, list->count);
    for (size_t i = 0; i < list->count; i++) {
        w.total += model_bytes(&w, &list->tensors[i]);
        report->values += (double)list->tensors[i].count;
    }
    model_deal(&w, list, shards);
    w.block = (unsigned char*)gsf_alloc(ctx, MODEL_BLOCK, gsf_nn_dtype_size(o->dtype));
    if (!w.block) return GSF_ERROR_OUT_OF_MEMORY;
    const gsf_result result = model_write_shards(&w, folder, single, list, shards);
    gsf_free(ctx, w.block);
    report->tensors = list->count;
    report->bytes = w.total;
    report->seconds = model_now() - start;
    return result;
}

// Its sizes come out of the text that goes into config.json; at the end the folder is opened.
static gsf_result model_make_transformer(gsf_context* ctx, const model_options* o, const char* folder,
                                         model_report* report) {
    gsf_text text;
    gsf__nn_config config;
    gsf_nn_transformer net;
    model_list list = model_begin_list(ctx, MODEL_TRANSFORMER);
    memset(&text, 0, sizeof text);
    memset(&net, 0, sizeof net);
    GSF__TRY(model_make_folder(ctx, folder));
    model_print_transformer(ctx, o->size, &text);
    gsf_result result = text.failed ? GSF_ERROR_OUT_OF_MEMORY
                                    : gsf__nn_parse_config(ctx, "config.json", text.data, text.size, &config);
    if (result == GSF_OK) {
        result = gsf__dit_read_config(&config, &net);
        gsf__nn_close_config(&config);
    }
    net.dino_channels = MODEL_DINO_CHANNELS;
    net.vggt_channels = MODEL_VGGT_CHANNELS;
    if (result == GSF_OK) {
        model_list_transformer(&list, &net);
        result = model_write_list(ctx, o, folder, MODEL_SINGLE, &list, o->shards, report);
    }
    if (result == GSF_OK) result = model_write_text(ctx, folder, "config.json", text.data, text.size);
    if (result == GSF_OK) {
        result = gsf_nn_make_transformer(ctx, folder, &net);
        if (result == GSF_OK) gsf_nn_destroy_transformer(ctx, &net);
    }
    gsf_free(ctx, list.tensors);
    gsf_destroy_text(ctx, &text);
    return result;
}

static gsf_result model_make_vae(gsf_context* ctx, const model_options* o, const char* folder, model_report* report) {
    gsf_text text;
    gsf__nn_config config;
    gsf_nn_vae vae;
    model_list list = model_begin_list(ctx, MODEL_VAE);
    memset(&text, 0, sizeof text);
    memset(&vae, 0, sizeof vae);
    GSF__TRY(model_make_folder(ctx, folder));
    model_print_vae(ctx, o->size, &text);
    gsf_result result = text.failed ? GSF_ERROR_OUT_OF_MEMORY
                                    : gsf__nn_parse_config(ctx, "config.json", text.data, text.size, &config);
    if (result == GSF_OK) {
        result = gsf__vae_take_config(&config, &vae);
        gsf__nn_close_config(&config);
    }
    if (result == GSF_OK) {
        model_list_vae(&list, &vae);
        result = model_write_list(ctx, o, folder, MODEL_SINGLE, &list, 1, report);
    }
    if (result == GSF_OK) result = model_write_text(ctx, folder, "config.json", text.data, text.size);
    if (result == GSF_OK) {
        result = gsf_nn_make_vae(ctx, folder, &vae);
        if (result == GSF_OK) gsf_nn_destroy_vae(ctx, &vae);
    }
    gsf_free(ctx, list.tensors);
    gsf_destroy_text(ctx, &text);
    return result;
}

static gsf_result model_make_features(gsf_context* ctx, const model_options* o, const char* folder,
                                      model_report* report) {
    model_list list = model_begin_list(ctx, MODEL_FEATURES);
    model_list_features(&list, o->size);
    const gsf_result result = model_write_list(ctx, o, folder, "features.safetensors", &list, 1, report);
    gsf_free(ctx, list.tensors);
    return result;
}

static gsf_result model_make_scheduler(gsf_context* ctx, const model_options* o, const char* folder,
                                       model_report* report) {
    (void)o;
    (void)report;
    GSF__TRY(model_make_folder(ctx, folder));
    return model_write_text(ctx, folder, "scheduler_config.json", model_scheduler, sizeof model_scheduler - 1);
}

enum { MODEL_PARTS = 4 };
static const struct model_part {
    const char *name, *folder;
    unsigned bit;
    gsf_result (*make_fn)(gsf_context* ctx, const model_options* o, const char* folder, model_report* report);
} model_parts[MODEL_PARTS] = {
    {"transformer", "/transformer", MODEL_TRANSFORMER, model_make_transformer},
    {"vae", "/vae", MODEL_VAE, model_make_vae},
    {"scheduler", "/scheduler", MODEL_SCHEDULER, model_make_scheduler},
    {"features", "", MODEL_FEATURES, model_make_features},
};

// reports: MODEL_PARTS of them; a part that was not asked for has no name.
static gsf_result model_make(gsf_context* ctx, const model_options* o, model_report* reports) {
    memset(reports, 0, MODEL_PARTS * sizeof *reports);
    GSF__TRY(model_make_folder(ctx, o->out));
    for (int i = 0; i < MODEL_PARTS; i++) {
        if (!(o->parts & model_parts[i].bit)) continue;
        gsf_text folder;
        memset(&folder, 0, sizeof folder);
        gsf_text_printf(ctx, &folder, "%s%s", o->out, model_parts[i].folder);
        reports[i].part = model_parts[i].name;
        const gsf_result result =
            folder.failed ? GSF_ERROR_OUT_OF_MEMORY : model_parts[i].make_fn(ctx, o, folder.data, &reports[i]);
        gsf_destroy_text(ctx, &folder);
        if (result != GSF_OK) return result;
    }
    return model_write_text(ctx, o->out, "model_index.json", model_index, sizeof model_index - 1);
}

// ---- the program -----------------------------------------------------------------

static const char model_usage[] =
    "usage: make_model OUT [--size tiny|small|full] [--dtype f32|bf16|f16] [--seed S] [--shards N] [--threads N]\n"
    "                      [--parts transformer,vae,scheduler,features]\n";

static gsf_context* model_context; // for the signal
static void model_interrupt(int number) {
    (void)number;
    gsf_request_cancel(model_context);
}

static void model_show_progress(void* user, const char* stage, double done, double total) {
    int* shown = (int*)user; // percent
    const int percent = (int)(100.0 * done / total);
    if (percent == *shown) return;
    *shown = percent;
    if (total >= 1e9 && percent % 10 == 0) fprintf(stderr, "make_model: %s %d%%\n", stage, percent);
}

static int model_read_number(const char* text, uint64_t high, uint64_t* out) {
    char* end = NULL;
    errno = 0;
    *out = strtoull(text, &end, 10);
    return text[0] >= '0' && text[0] <= '9' && *end == 0 && errno == 0 && *out <= high;
}

static int model_read_parts(const char* text, unsigned* parts) {
    *parts = 0;
    for (;; text++) {
        const size_t size = strcspn(text, ",");
        unsigned bit = 0;
        for (int i = 0; i < MODEL_PARTS; i++)
            if (strlen(model_parts[i].name) == size && memcmp(model_parts[i].name, text, size) == 0)
                bit = model_parts[i].bit;
        if (!bit) return 0;
        *parts |= bit;
        text += size;
        if (!*text) return 1;
    }
}

static int model_read_option(const char* name, const char* value, model_options* o, int* threads) {
    static const gsf_nn_dtype dtypes[] = {GSF_NN_F32, GSF_NN_BF16, GSF_NN_F16};
    static const char* const dtype_names[] = {"f32", "bf16", "f16"};
    uint64_t number;
    if (strcmp(name, "--seed") == 0) return model_read_number(value, UINT64_MAX, &o->seed);
    if (strcmp(name, "--parts") == 0) return model_read_parts(value, &o->parts);
    if (strcmp(name, "--shards") == 0) {
        const int ok = model_read_number(value, 999, &number) && number >= 1;
        if (ok) o->shards = (int)number;
        return ok;
    }
    if (strcmp(name, "--threads") == 0) {
        const int ok = model_read_number(value, 1024, &number) && number >= 1;
        if (ok) *threads = (int)number;
        return ok;
    }
    int found = 0;
    for (size_t i = 0; i < GSF__COUNT(dtypes) && strcmp(name, "--dtype") == 0; i++) {
        if (strcmp(value, dtype_names[i]) != 0) continue;
        o->dtype = dtypes[i];
        found = 1;
    }
    for (size_t i = 0; i < GSF__COUNT(model_sizes) && strcmp(name, "--size") == 0; i++) {
        if (strcmp(value, model_sizes[i].name) != 0) continue;
        o->size = &model_sizes[i];
        found = 1;
    }
    return found;
}

static int model_read_options(int argc, char** argv, model_options* o, int* threads) {
    memset(o, 0, sizeof *o);
    o->size = &model_sizes[1];
    o->dtype = GSF_NN_BF16;
    o->shards = 1;
    o->parts = MODEL_ALL;
    *threads = 0;
    for (int i = 1; i < argc; i++) {
        if (argv[i][0] == '-') {
            if (i + 1 == argc || !model_read_option(argv[i], argv[i + 1], o, threads)) return 0;
            i++;
        } else {
            if (o->out) return 0;
            o->out = argv[i];
        }
    }
    return o->out != NULL;
}

int main(int argc, char** argv) {
    model_options o;
    model_report reports[MODEL_PARTS];
    gsf_context ctx;
    int threads, shown = 0;
    if (argc == 2 && strcmp(argv[1], "--help") == 0) {
        fputs(model_usage, stdout);
        return 0;
    }
    if (!model_read_options(argc, argv, &o, &threads)) {
        fputs(model_usage, stderr);
        return 2;
    }
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = threads;
    ctx.progress.progress_fn = model_show_progress;
    ctx.progress.user = &shown;
    gsf_result result = gsf_init_context(&ctx);
    model_context = &ctx;
    signal(SIGINT, model_interrupt);
    signal(SIGTERM, model_interrupt);
    if (result == GSF_OK) result = model_make(&ctx, &o, reports);
    if (result != GSF_OK) {
        fprintf(stderr, "make_model: %s\n", ctx.error[0] ? ctx.error : gsf_describe_result(result));
        return 1;
    }
    for (int i = 0; i < MODEL_PARTS; i++)
        if (reports[i].tensors)
            printf("%-12s %5zu tensors  %11.0f values  %12.0f bytes  %7.2f s\n", reports[i].part, reports[i].tensors,
                   reports[i].values, reports[i].bytes, reports[i].seconds);
    return 0;
}
