// make_model.c - a restorer model with seeded random weights in the layout of the GSFixer release, at its size or
// smaller, for benches and tests of speed, memory and data flow. Its output is noise. By hand: cc -O2 -fopenmp -I.
// bench/make_model.c -o make_model -lm
//
//     make_model OUT [--size tiny|small|full] [--dtype f32|bf16|f16] [--seed S] [--shards N] [--threads N]
//                    [--layers N] [--parts transformer,vae,scheduler,features,dinov2,vggt,text,blip2]
//
// --layers N: number of layers of every network except the autoencoder, for the widths of `full` without its depth.
// Defaults: small, bf16, seed 0, one file, all parts. `full` has the release's configuration: 34.3 GB in bf16 (14.9 GB
// of it transformer and VAE), of which only one block of values is in memory at a time. OUT gets
//     transformer/{config.json, diffusion_pytorch_model*.safetensors}      with N > 1 shards and their index
//     vae/{config.json, diffusion_pytorch_model.safetensors}
//     scheduler/scheduler_config.json, model_index.json
//     features.safetensors    dino_latents (2, tokens, 1024), vggt_latents (2, tokens, 2048): two reference images;
//                             prompt_embeds (2, text tokens, text channels): negative and positive
//     dinov2/, vggt/          {config.json, model.safetensors}             encoders of reference images
//     text_encoder/{config.json, model*.safetensors}                       T5, also in shards
//     tokenizer/{spiece.model, ...}                                        its pieces: ASCII and some words of captions
//     blip2/{config.json, model*.safetensors, vocab.json, merges.txt, preprocessor_config.json, ...}    also in shards
// The encoders of tiny and small have one layer; the vocabularies are the same few hundred tokens at all sizes.
// A value depends only on seed, tensor and index, not on shards, threads or other parts; narrow dtypes hold the rounded
// f32 values. Each file is written under a temporary name and renamed. OUT must be a new folder or one that make_model
// made (it contains make_model.txt), so that a folder of real weights is never written into.
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

// hidden: width of the feed-forward layers
typedef struct model_blocks { int width, heads, hidden, layers; } model_blocks;

typedef struct model_size {
    const char* name;
    int heads, layers, time_channels, text_tokens; // heads of 64
    int sample_height, sample_width, frames;       // latents; frames of a clip
    int reference_tokens;                          // per image
    int channels[4], vae_layers, vae_groups;
    int vae_height, vae_width; // pixels; multiples of 96 and 80, so that tiles overlap by whole latents
    model_blocks text;         // T5; heads of 64
    int text_words;            // size of its vocabulary
    model_blocks eyes;         // DINOv2, and each of VGGT's three stacks
    int eyes_grid;             // patches along a side of their configured image size
    model_blocks see, ask, tell; // BLIP-2: vision, queries, language
    int see_side, queries, tell_words, tell_tokens; // pixels; vocabulary; longest text
} model_size;

static const model_size model_sizes[] = {
    {"tiny", 2, 2, 64, 26, 8, 12, 9, 8, {8, 16, 16, 24}, 1, 4, 96, 80,
     {64, 2, 160, 1}, 320, {1024, 16, 1024, 1}, 5, {128, 2, 256, 1}, {64, 1, 128, 1}, {192, 3, 256, 1}, 56, 4, 640, 64},
    {"small", 8, 6, 256, 64, 16, 24, 17, 70, {32, 64, 64, 128}, 2, 8, 192, 240,
     {512, 8, 1024, 1}, 320, {1024, 16, 4096, 1}, 37, {256, 4, 512, 1}, {128, 2, 256, 1}, {256, 4, 512, 1}, 112, 8, 640,
     128},
    {"full", 48, 42, 512, 226, 60, 90, 49, 925, {128, 256, 256, 512}, 3, 32, 480, 720,
     {4096, 64, 10240, 24}, 32128, {1024, 16, 4096, 24}, 37, {1408, 16, 6144, 39}, {768, 12, 3072, 12},
     {2560, 32, 10240, 32}, 224, 32, 50304, 2048},
};

enum { MODEL_PATCH = 14, MODEL_REGISTERS = 4 }; // of the image encoders

static void model_print_transformer(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "{\n  \"_class_name\": \"CogVideoXCrossTransformer3DModel\",\n  \"_diffusers_version\": \"0.32.1\",\n"
                    "  \"activation_fn\": \"gelu-approximate\",\n  \"attention_bias\": true,\n"
                    "  \"attention_head_dim\": 64,\n  \"dropout\": 0.0,\n  \"flip_sin_to_cos\": true,\n"
                    "  \"freq_shift\": 0,\n  \"in_channels\": 32,\n  \"max_text_seq_length\": %d,\n"
                    "  \"norm_elementwise_affine\": true,\n  \"norm_eps\": 1e-05,\n  \"num_attention_heads\": %d,\n"
                    "  \"num_layers\": %d,\n  \"ofs_embed_dim\": null,\n  \"out_channels\": 16,\n"
                    "  \"patch_bias\": true,\n  \"patch_size\": 2,\n  \"patch_size_t\": null,\n",
                    s->text_tokens, s->heads, s->layers);
    gsf_append_text(ctx, out,
                    "  \"sample_frames\": %d,\n  \"sample_height\": %d,\n  \"sample_width\": %d,\n"
                    "  \"spatial_interpolation_scale\": 1.875,\n  \"temporal_compression_ratio\": 4,\n"
                    "  \"temporal_interpolation_scale\": 1.0,\n  \"text_embed_dim\": %d,\n  \"time_embed_dim\": %d,\n"
                    "  \"timestep_activation_fn\": \"silu\",\n  \"use_learned_positional_embeddings\": true,\n"
                    "  \"use_rotary_positional_embeddings\": true\n}\n",
                    s->frames, s->sample_height, s->sample_width, s->text.width, s->time_channels);
}

static void model_print_vae(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "{\n  \"_class_name\": \"AutoencoderKLCogVideoX\",\n  \"_diffusers_version\": \"0.32.1\",\n"
                    "  \"act_fn\": \"silu\",\n  \"block_out_channels\": [\n    %d,\n    %d,\n    %d,\n    %d\n  ],\n",
                    s->channels[0], s->channels[1], s->channels[2], s->channels[3]);
    for (int up = 0; up < 2; up++) {
        const char* way = up ? "Up" : "Down";
        if (up)
            gsf_append_text(ctx, out,
                            "  \"force_upcast\": true,\n  \"in_channels\": 3,\n  \"invert_scale_latents\": false,\n"
                            "  \"latent_channels\": 16,\n  \"latents_mean\": null,\n  \"latents_std\": null,\n"
                            "  \"layers_per_block\": %d,\n  \"norm_eps\": 1e-06,\n  \"norm_num_groups\": %d,\n"
                            "  \"out_channels\": 3,\n  \"sample_height\": %d,\n  \"sample_width\": %d,\n"
                            "  \"scaling_factor\": 0.7,\n  \"shift_factor\": null,\n"
                            "  \"temporal_compression_ratio\": 4,\n",
                            s->vae_layers, s->vae_groups, s->vae_height, s->vae_width);
        gsf_append_text(ctx, out, "  \"%s_block_types\": [\n", up ? "up" : "down");
        for (int i = 0; i < 4; i++) gsf_append_text(ctx, out, "    \"CogVideoX%sBlock3D\"%s\n", way, i < 3 ? "," : "");
        gsf_append_text(ctx, out, "  ],\n");
    }
    gsf_append_text(ctx, out, "  \"use_post_quant_conv\": false,\n  \"use_quant_conv\": false\n}\n");
}

static void model_print_scheduler(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    (void)s;
    gsf_append_text(ctx, out,
                    "{\n  \"_class_name\": \"CogVideoXDDIMScheduler\",\n  \"_diffusers_version\": \"0.32.1\",\n"
                    "  \"beta_end\": 0.012,\n  \"beta_schedule\": \"scaled_linear\",\n  \"beta_start\": 0.00085,\n"
                    "  \"clip_sample\": false,\n  \"clip_sample_range\": 1.0,\n  \"num_train_timesteps\": 1000,\n"
                    "  \"prediction_type\": \"v_prediction\",\n  \"rescale_betas_zero_snr\": true,\n"
                    "  \"sample_max_value\": 1.0,\n  \"set_alpha_to_one\": true,\n  \"snr_shift_scale\": 1.0,\n"
                    "  \"steps_offset\": 0,\n  \"timestep_spacing\": \"trailing\",\n  \"trained_betas\": null\n}\n");
}

// A missing text encoder is written as two nulls, as in diffusers: features.safetensors has the embeddings.
static void model_print_pipeline(gsf_context* ctx, int has_text, gsf_buffer* out) {
    static const char* const classes[][2] = {{"text_encoder", "T5EncoderModel"}, {"tokenizer", "T5Tokenizer"}};
    gsf_append_text(ctx, out,
                    "{\n  \"_class_name\": \"CogVideoXImageToVideoPipeline\",\n  \"_diffusers_version\": \"0.32.1\",\n"
                    "  \"scheduler\": [\n    \"diffusers\",\n    \"CogVideoXDDIMScheduler\"\n  ],\n");
    for (int i = 0; i < 2; i++) {
        if (has_text)
            gsf_append_text(ctx, out, "  \"%s\": [\n    \"transformers\",\n    \"%s\"\n  ],\n", classes[i][0],
                            classes[i][1]);
        else gsf_append_text(ctx, out, "  \"%s\": [\n    null,\n    null\n  ],\n", classes[i][0]);
    }
    gsf_append_text(ctx, out,
                    "  \"transformer\": [\n    \"diffusers\",\n    \"CogVideoXTransformer3DModel\"\n  ],\n"
                    "  \"vae\": [\n    \"diffusers\",\n    \"AutoencoderKLCogVideoX\"\n  ]\n}\n");
}

static void model_print_dinov2(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "{\n  \"architectures\": [\n    \"Dinov2WithRegistersModel\"\n  ],\n  \"hidden_act\": \"gelu\",\n"
                    "  \"hidden_size\": %d,\n  \"image_size\": %d,\n  \"layer_norm_eps\": 1e-06,\n  \"mlp_ratio\": %d,\n"
                    "  \"model_type\": \"dinov2_with_registers\",\n  \"num_attention_heads\": %d,\n"
                    "  \"num_channels\": 3,\n  \"num_hidden_layers\": %d,\n  \"num_register_tokens\": %d,\n"
                    "  \"patch_size\": %d,\n  \"qkv_bias\": true,\n  \"transformers_version\": \"4.51.3\",\n"
                    "  \"use_swiglu_ffn\": false\n}\n",
                    s->eyes.width, s->eyes_grid * MODEL_PATCH, s->eyes.hidden / s->eyes.width, s->eyes.heads,
                    s->eyes.layers, (int)MODEL_REGISTERS, (int)MODEL_PATCH);
}

static void model_print_vggt(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out, "{\n  \"embed_dim\": %d,\n  \"img_size\": %d,\n  \"patch_size\": %d\n}\n", s->eyes.width,
                    s->eyes_grid * MODEL_PATCH, (int)MODEL_PATCH);
}

static void model_print_t5(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "{\n  \"architectures\": [\n    \"T5EncoderModel\"\n  ],\n  \"d_ff\": %d,\n  \"d_kv\": 64,\n"
                    "  \"d_model\": %d,\n  \"decoder_start_token_id\": 0,\n  \"dense_act_fn\": \"gelu_new\",\n"
                    "  \"dropout_rate\": 0.1,\n  \"eos_token_id\": 1,\n  \"feed_forward_proj\": \"gated-gelu\",\n"
                    "  \"is_encoder_decoder\": true,\n  \"is_gated_act\": true,\n  \"layer_norm_epsilon\": 1e-06,\n"
                    "  \"model_type\": \"t5\",\n  \"num_decoder_layers\": %d,\n  \"num_heads\": %d,\n",
                    s->text.hidden, s->text.width, s->text.layers, s->text.heads);
    gsf_append_text(ctx, out,
                    "  \"num_layers\": %d,\n  \"pad_token_id\": 0,\n  \"relative_attention_max_distance\": 128,\n"
                    "  \"relative_attention_num_buckets\": 32,\n  \"tie_word_embeddings\": false,\n"
                    "  \"transformers_version\": \"4.51.3\",\n  \"use_cache\": true,\n  \"vocab_size\": %d\n}\n",
                    s->text.layers, s->text_words);
}

// Ids of BLIP-2's vocabulary: four special tokens, the 256 bytes, the words and their prefixes, finally <image>.
enum { MODEL_BYTE_0 = 4, MODEL_CAPTION_END = MODEL_BYTE_0 + '\n', MODEL_WORD_0 = MODEL_BYTE_0 + 256 };

static void model_print_blocks(gsf_context* ctx, const model_blocks* b, const char* hidden, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "    \"hidden_size\": %d,\n    \"%s\": %d,\n    \"num_attention_heads\": %d,\n"
                    "    \"num_hidden_layers\": %d,\n",
                    b->width, hidden, b->hidden, b->heads, b->layers);
}

static void model_print_blip2(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "{\n  \"architectures\": [\n    \"Blip2ForConditionalGeneration\"\n  ],\n"
                    "  \"image_text_hidden_size\": 256,\n  \"image_token_index\": %d,\n  \"model_type\": \"blip-2\",\n"
                    "  \"num_query_tokens\": %d,\n  \"qformer_config\": {\n    \"cross_attention_frequency\": 2,\n"
                    "    \"encoder_hidden_size\": %d,\n    \"hidden_act\": \"gelu\",\n",
                    s->tell_words - 1, s->queries, s->see.width);
    model_print_blocks(ctx, &s->ask, "intermediate_size", out);
    gsf_append_text(ctx, out,
                    "    \"layer_norm_eps\": 1e-12,\n    \"model_type\": \"blip_2_qformer\",\n"
                    "    \"position_embedding_type\": \"absolute\",\n    \"use_qformer_text_input\": false\n  },\n"
                    "  \"text_config\": {\n    \"activation_function\": \"relu\",\n    \"bos_token_id\": 2,\n"
                    "    \"do_layer_norm_before\": true,\n    \"eos_token_id\": %d,\n",
                    (int)MODEL_CAPTION_END);
    model_print_blocks(ctx, &s->tell, "ffn_dim", out);
    gsf_append_text(ctx, out,
                    "    \"max_position_embeddings\": %d,\n    \"model_type\": \"opt\",\n    \"vocab_size\": %d,\n"
                    "    \"word_embed_proj_dim\": %d\n  },\n  \"transformers_version\": \"4.51.3\",\n"
                    "  \"use_decoder_only_language_model\": true,\n  \"vision_config\": {\n    \"hidden_act\": \"gelu\",\n",
                    s->tell_tokens, s->tell_words, s->tell.width);
    model_print_blocks(ctx, &s->see, "intermediate_size", out);
    gsf_append_text(ctx, out,
                    "    \"image_size\": %d,\n    \"layer_norm_eps\": 1e-06,\n"
                    "    \"model_type\": \"blip_2_vision_model\",\n    \"patch_size\": %d,\n    \"qkv_bias\": true\n"
                    "  }\n}\n",
                    s->see_side, (int)MODEL_PATCH);
}

static void model_print_blip2_images(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out,
                    "{\n  \"do_convert_rgb\": true,\n  \"do_normalize\": true,\n  \"do_rescale\": true,\n"
                    "  \"do_resize\": true,\n  \"image_mean\": [\n    0.48145466,\n    0.4578275,\n    0.40821073\n  ],\n"
                    "  \"image_processor_type\": \"BlipImageProcessor\",\n"
                    "  \"image_std\": [\n    0.26862954,\n    0.26130258,\n    0.27577711\n  ],\n"
                    "  \"processor_class\": \"Blip2Processor\",\n  \"resample\": 3,\n"
                    "  \"rescale_factor\": 0.00392156862745098,\n"
                    "  \"size\": {\n    \"height\": %d,\n    \"width\": %d\n  }\n}\n",
                    s->see_side, s->see_side);
}

static void model_print_blip2_processor(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out, "{\n  \"num_query_tokens\": %d,\n  \"processor_class\": \"Blip2Processor\"\n}\n", s->queries);
}

static void model_print_blip2_generation(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    (void)s;
    gsf_append_text(ctx, out,
                    "{\n  \"_from_model_config\": true,\n  \"bos_token_id\": 2,\n  \"eos_token_id\": %d,\n"
                    "  \"pad_token_id\": 1,\n  \"transformers_version\": \"4.51.3\"\n}\n",
                    (int)MODEL_CAPTION_END);
}

// ---- the vocabularies ------------------------------------------------------------

static const char* const model_words[] = { // of captions; sorted, as model_print_words requires
    "a", "above", "an", "and", "are", "art", "at", "background", "beach", "behind", "beside", "black", "blue", "boat",
    "book", "bridge", "brown", "building", "by", "camera", "car", "chair", "city", "cloud", "clouds", "dark", "day",
    "dog", "door", "field", "floor", "flower", "flowers", "fox", "front", "garden", "glass", "grass", "gray", "green",
    "ground", "hill", "horse", "house", "image", "in", "is", "kitchen", "lake", "large", "leaf", "leaves", "light",
    "man", "mountain", "near", "next", "night", "of", "old", "on", "open", "orange", "park", "path", "people",
    "photo", "picture", "plant", "plants", "quality", "red", "river", "road", "rock", "rocks", "roof", "room", "sand",
    "sea", "shelf", "side", "sitting", "sky", "small", "snow", "standing", "stone", "street", "sun", "sunny", "table",
    "that", "the", "there", "this", "to", "top", "tower", "town", "tree", "trees", "truck", "two", "video", "view",
    "walking", "wall", "water", "white", "window", "with", "woman", "wood", "wooden", "yellow"
};

static void model_print_token(gsf_context* ctx, gsf_buffer* out, int id, const char* text,
                              int strip) { // a token of added_tokens_decoder
    const char* flag = strip ? "true" : "false";
    gsf_append_text(ctx, out,
                    "    \"%d\": {\"content\": \"%s\", \"lstrip\": %s, \"normalized\": false, \"rstrip\": %s, "
                    "\"single_word\": false, \"special\": true}",
                    id, text, flag, flag);
}

// ---- T5's vocabulary: a unigram model (for its messages see gsfixer_nn.h, >>nn tokenizer; all shorter than 128 bytes)

enum { MODEL_PIECES = 4 + (int)GSF__COUNT(model_words) + '~' - '!' + 1 }; // <pad>, </s>, <unk>, space, words, ASCII

static void model_put_piece(gsf_context* ctx, gsf_buffer* out, const char* before, const char* text, double score,
                            int type) {
    const float value = (float)score;
    const size_t first = strlen(before), size = first + strlen(text);
    const unsigned char head[4] = {1 << 3 | 2, (unsigned char)(size + 9), 1 << 3 | 2, (unsigned char)size};
    unsigned char tail[7] = {2 << 3 | 5, 0, 0, 0, 0, 3 << 3, (unsigned char)type};
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    gsf__store_le(tail + 1, bits, 4);
    gsf_append_bytes(ctx, out, (const char*)head, sizeof head);
    gsf_append_bytes(ctx, out, before, first);
    gsf_append_bytes(ctx, out, text, size - first);
    gsf_append_bytes(ctx, out, (const char*)tail, sizeof tail);
}

// A word scores higher than its characters together.
static void model_print_pieces(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    static const char ends[] = "\x12\x02\x18\x01"                 // trainer: kind 1, a unigram
                               "\x1a\x0a\x0a\x08" "identity"; // normaliser: its name; characters stay as they are
    (void)s;
    model_put_piece(ctx, out, "", "<pad>", 0.0, GSF__SP_CONTROL);
    model_put_piece(ctx, out, "", "</s>", 0.0, GSF__SP_CONTROL);
    model_put_piece(ctx, out, "", "<unk>", 0.0, GSF__SP_UNKNOWN);
    model_put_piece(ctx, out, gsf__sp_space, "", -3.0, GSF__SP_NORMAL);
    for (size_t i = 0; i < GSF__COUNT(model_words); i++)
        model_put_piece(ctx, out, gsf__sp_space, model_words[i], -5.0 - 0.01 * (double)i, GSF__SP_NORMAL);
    for (char c = '!'; c <= '~'; c++) {
        const char text[2] = {c, 0};
        model_put_piece(ctx, out, "", text, -8.0 - 0.01 * (c - '!'), GSF__SP_NORMAL);
    }
    gsf_append_bytes(ctx, out, ends, sizeof ends - 1);
}

static void model_print_t5_added(gsf_context* ctx, const model_size* s,
                                 gsf_buffer* out) { // <extra_id_0> is the last one
    (void)s;
    for (int i = 0; i < GSF__SP_EXTRA; i++)
        gsf_append_text(ctx, out, "%s  \"<extra_id_%d>\": %d", i ? ",\n" : "{\n", i, MODEL_PIECES + GSF__SP_EXTRA - 1 - i);
    gsf_append_text(ctx, out, "\n}\n");
}

static void model_print_t5_tokenizer(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    static const char* const special[] = {"<pad>", "</s>", "<unk>"};
    char name[32];
    gsf_append_text(ctx, out, "{\n  \"added_tokens_decoder\": {\n");
    for (int i = 0; i < 3; i++) {
        model_print_token(ctx, out, i, special[i], 0);
        gsf_append_text(ctx, out, ",\n");
    }
    for (int i = GSF__SP_EXTRA; i-- > 0;) {
        snprintf(name, sizeof name, "<extra_id_%d>", i);
        model_print_token(ctx, out, MODEL_PIECES + GSF__SP_EXTRA - 1 - i, name, 1);
        gsf_append_text(ctx, out, "%s\n", i ? "," : "");
    }
    gsf_append_text(ctx, out,
                    "  },\n  \"eos_token\": \"</s>\",\n  \"extra_ids\": %d,\n  \"legacy\": true,\n"
                    "  \"model_max_length\": %d,\n  \"pad_token\": \"<pad>\",\n"
                    "  \"tokenizer_class\": \"T5Tokenizer\",\n  \"unk_token\": \"<unk>\"\n}\n",
                    (int)GSF__SP_EXTRA, s->text_tokens);
}

// ---- BLIP-2's vocabulary: byte pair encoding

static void model_print_entry(gsf_context* ctx, gsf_buffer* out, const char* text, int id) {
    gsf_append_text(ctx, out, "%s  ", id ? ",\n" : "{\n");
    gsf_append_json_string(ctx, out, text);
    gsf_append_text(ctx, out, ": %d", id);
}

// Every prefix of a word, including the leading space, is a token, so that each is one character longer than another.
// Printed as vocabulary entries or as merges.
static void model_print_words(gsf_context* ctx, int merges, gsf_buffer* out) {
    char text[48];
    const size_t space = gsf__bpe_store_character(gsf__bpe_character(' '), text);
    int id = MODEL_WORD_0;
    for (size_t i = 0; i < GSF__COUNT(model_words); i++) {
        const char* word = model_words[i];
        size_t n = 0; // characters shared with the beginning of the previous word
        while (i && word[n] && word[n] == model_words[i - 1][n]) n++;
        for (; word[n]; n++) {
            snprintf(text + space, sizeof text - space, "%.*s", (int)n + !merges, word);
            if (merges) gsf_append_text(ctx, out, "%s %c\n", text, word[n]);
            else model_print_entry(ctx, out, text, id++);
        }
    }
}

static void model_print_vocabulary(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    static const char* const special[MODEL_BYTE_0] = {"<s>", "<pad>", "</s>", "<unk>"};
    char text[4];
    (void)s;
    for (int i = 0; i < MODEL_BYTE_0; i++) model_print_entry(ctx, out, special[i], i);
    for (int i = 0; i < 256; i++) {
        text[gsf__bpe_store_character(gsf__bpe_character((unsigned)i), text)] = 0;
        model_print_entry(ctx, out, text, MODEL_BYTE_0 + i);
    }
    model_print_words(ctx, 0, out);
    gsf_append_text(ctx, out, "\n}\n");
}

static void model_print_merges(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    (void)s;
    gsf_append_text(ctx, out, "#version: 0.2\n");
    model_print_words(ctx, 1, out);
}

static void model_print_blip2_added(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out, "{\n  \"<image>\": %d\n}\n", s->tell_words - 1);
}

#define MODEL_BLIP2_SPECIAL \
    "  \"additional_special_tokens\": [\"<image>\"],\n  \"bos_token\": \"</s>\",\n  \"eos_token\": \"</s>\",\n" \
    "  \"pad_token\": \"<pad>\",\n  \"unk_token\": \"</s>\"\n}\n"

static void model_print_blip2_special(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    (void)s;
    gsf_append_text(ctx, out, "{\n" MODEL_BLIP2_SPECIAL);
}

static void model_print_blip2_tokenizer(gsf_context* ctx, const model_size* s, gsf_buffer* out) {
    gsf_append_text(ctx, out, "{\n  \"add_bos_token\": true,\n  \"added_tokens_decoder\": {\n");
    model_print_token(ctx, out, 1, "<pad>", 0);
    gsf_append_text(ctx, out, ",\n");
    model_print_token(ctx, out, 2, "</s>", 0);
    gsf_append_text(ctx, out, ",\n");
    model_print_token(ctx, out, s->tell_words - 1, "<image>", 0);
    gsf_append_text(ctx, out, "\n  },\n  \"tokenizer_class\": \"GPT2Tokenizer\",\n" MODEL_BLIP2_SPECIAL);
}

// ---- the tensors of a part -------------------------------------------------------

typedef struct model_tensor {
    char name[104];
    int64_t shape[5], count;
    int32_t rank, shard;
    uint64_t stream;       // stream of its random numbers
    double middle, spread; // values are uniform in middle - spread .. middle + spread
} model_tensor;

typedef struct model_list {
    gsf_context* ctx;
    model_tensor* tensors;
    size_t count, capacity;
    uint64_t stream; // stream of the first tensor
    int64_t dino, vggt; // channels of the reference tokens
    gsf_result result;
} model_list;

enum {
    MODEL_TRANSFORMER = 1, MODEL_VAE = 2, MODEL_SCHEDULER = 4, MODEL_FEATURES = 8, MODEL_DINOV2 = 16, MODEL_VGGT = 32,
    MODEL_TEXT = 64, MODEL_BLIP2 = 128, MODEL_ALL = 255
};

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

typedef struct model_range { const char* end; double middle, spread, factor; } model_range;

// Ranges by suffix of a tensor's name: uniform in middle - spread .. middle + spread or, if spread is 0, `factor` times
// the default range. The first match applies.
static const model_range model_ranges[] = {
    // its output is used as a factor as well
    {".conv_y.conv.bias", 1.0, 0.05, 0.0}, {".conv_y.conv.weight", 0.0, 0.0, 0.25},
    {".pos_embedding", 0.0, 0.05, 0.0}, // added to the transformer's tokens
    {"_latents", 0.0, 1.7320508075688772, 0.0}, {"_embeds", 0.0, 1.7320508075688772, 0.0}, // variance 1
    {".lambda1", 1.0, 0.1, 0.0}, {".gamma", 1.0, 0.1, 0.0}, // LayerScale
    {"SelfAttention.q.weight", 0.0, 0.0, 0.125},            // T5 does not scale the logits of its heads of 64
    {"shared.weight", 0.0, 1.7320508075688772, 0.0},
    {"embed_positions.weight", 0.0, 1.0, 0.0}, {"_token", 0.0, 1.0, 0.0}, {"_tokens", 0.0, 1.0, 0.0},
    {"_embedding", 0.0, 1.0, 0.0}, {"_embeddings", 0.0, 1.0, 0.0}, {".pos_embed", 0.0, 1.0, 0.0},
};

// Every layer preserves the magnitude of its input: weights with variance 1 / fan-in, norms near 1. The modulations and
// gates of the transformer's blocks are then about 0.2, which follows from the magnitude of the time embedding.
static void model_choose_range(model_tensor* t) {
    const int norm = t->rank == 1 && model_ends_in(t->name, ".weight");
    t->middle = norm ? 1.0 : 0.0;
    t->spread = norm ? 0.1 : t->rank == 1 ? 0.05 : sqrt(3.0 / (double)(t->count / t->shape[0]));
    for (size_t i = 0; i < GSF__COUNT(model_ranges); i++) {
        const model_range* r = &model_ranges[i];
        if (!model_ends_in(t->name, r->end)) continue;
        t->middle = r->middle;
        t->spread = r->spread > 0.0 ? r->spread : r->factor * t->spread;
        break;
    }
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

// The tables that the loaders use have every name and shape, except for the channels of the reference tokens.
static gsf_result model_add_visited(void* user, const char* name, int32_t rank, const int64_t* shape,
                                    const gsf_nn_tensor** to) {
    model_list* list = (model_list*)user;
    int64_t known[GSF_NN_MAX_RANK];
    (void)to;
    for (int32_t i = 0; i < rank; i++) known[i] = shape[i] >= 0 ? shape[i] : strstr(name, "dino") ? list->dino : list->vggt;
    model_add(list, rank, known, "", name);
    return list->result;
}

static void model_add_entries(model_list* list, const gsf__nn_sizes* sizes, const gsf__nn_entry* entries,
                              const char* prefix) {
    union { gsf__vit vit; gsf__vggt vggt; gsf__blip blip; gsf__qformer_layer qformer; gsf__nn_block block; gsf__t5_nets t5;
            gsf__dit_nets dit; gsf__dit_block dit_block; } unused; // receives the tensors' addresses
    (void)gsf__nn_visit(sizes, entries, prefix, &unused, model_add_visited, list);
}

static void model_add_blocks(model_list* list, const gsf__nn_sizes* sizes, const gsf__nn_entry* entries, const char* names,
                             int64_t count) {
    char prefix[80];
    for (int64_t i = 0; i < count; i++) {
        snprintf(prefix, sizeof prefix, "%s%lld.", names, (long long)i);
        model_add_entries(list, sizes, entries, prefix);
    }
}

static void model_add_transformer(model_list* list, const gsf_nn_transformer* c) {
    const gsf__nn_sizes sizes = gsf__dit_tensor_sizes(c);
    list->dino = c->dino_channels;
    list->vggt = c->vggt_channels;
    model_add_entries(list, &sizes, gsf__dit_entries, "");
    model_add_blocks(list, &sizes, gsf__dit_block_entries, "transformer_blocks.", c->layers);
}

// The loader traverses the autoencoder without a table; this is the same traversal. Opening the model afterwards
// verifies it.
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
    // latents > 0: a norm of the decoder
    snprintf(full, sizeof full, "%s%s%s", prefix, name, latents ? ".norm_layer" : "");
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

static void model_add_vae(model_list* list, const gsf_nn_vae* vae) {
    model_add_coder(list, vae, 0);
    model_add_coder(list, vae, 1);
}

static void model_add_vit(model_list* list, const gsf__vit* vit, const gsf__nn_entry* entries, const char* prefix) {
    const gsf__nn_sizes sizes = gsf__vit_sizes(vit);
    model_add_entries(list, &sizes, entries, prefix);
}

static void model_add_vit_blocks(model_list* list, const gsf__nn_block_sizes* s, const gsf__nn_entry* entries,
                                 const char* names, int64_t layers) {
    const gsf__nn_sizes sizes = gsf__nn_sizes_of_block(s);
    model_add_blocks(list, &sizes, entries, names, layers);
}

static void model_add_dinov2(model_list* list, const gsf__vit* vit) {
    const int64_t mask[2] = {1, vit->sizes.width};
    model_add_vit(list, vit, gsf__dinov2_entries, "");
    model_add(list, 2, mask, "", "embeddings.mask_token"); // for training
    model_add_vit_blocks(list, &vit->sizes, gsf__dinov2_block_entries, vit->block_names, vit->layers);
}

static void model_add_vggt(model_list* list, const gsf__vggt* net) {
    const gsf__vit* vit = &net->embed;
    const gsf__nn_entry* entries = gsf__vggt_block_entries;
    const gsf__nn_sizes sizes = gsf__vggt_sizes(net);
    const int64_t mask[2] = {1, net->sizes.width};
    model_add_entries(list, &sizes, gsf__vggt_entries, "");
    model_add_vit(list, vit, gsf__vggt_embed_entries, "");
    model_add(list, 2, mask, vit->prefix, "mask_token");
    model_add_vit_blocks(list, &vit->sizes, entries, vit->block_names, vit->layers);
    model_add_vit_blocks(list, &net->sizes, entries, gsf__vggt_frame_names, net->layers);
    model_add_vit_blocks(list, &net->sizes, entries, gsf__vggt_global_names, net->layers);
}

static void model_add_t5(model_list* list, const gsf_nn_t5* c) {
    const gsf__nn_block_sizes block = gsf__t5_block_sizes(c);
    const gsf__nn_sizes sizes = gsf__t5_sizes(c), block_sizes = gsf__nn_sizes_of_block(&block);
    model_add_entries(list, &sizes, gsf__t5_entries, "");
    model_add_blocks(list, &block_sizes, gsf__t5_block_entries, "encoder.block.", c->layers);
}

static void model_add_blip2(model_list* list, const gsf__blip* net) {
    const gsf__vit* vit = &net->vision;
    const gsf__nn_sizes sizes = gsf__blip_sizes(net);
    model_add_vit(list, vit, gsf__blip_vision_entries, "vision_model.");
    model_add_vit_blocks(list, &vit->sizes, gsf__blip_block_entries, vit->block_names, vit->layers);
    model_add_entries(list, &sizes, gsf__blip_entries, "");
    for (int64_t i = 0; i < net->qformer.layers; i++) {
        const gsf__nn_sizes layer = gsf__qformer_sizes(net, i);
        char prefix[48];
        snprintf(prefix, sizeof prefix, "qformer.encoder.layer.%lld.", (long long)i);
        model_add_entries(list, &layer, gsf__qformer_layer_entries, prefix);
    }
    model_add_vit_blocks(list, &net->text.sizes, gsf__opt_block_entries, "language_model.model.decoder.layers.",
                         net->text.layers);
}

// ---- the list of a part: sizes are taken from the text of its config.json

static void model_list_transformer(model_list* list, const model_size* s, gsf__nn_config* config) {
    gsf_nn_transformer net;
    memset(&net, 0, sizeof net);
    list->result = gsf__dit_read_config(config, &net);
    net.dino_channels = s->eyes.width;
    net.vggt_channels = 2 * s->eyes.width;
    model_add_transformer(list, &net);
}

static void model_list_vae(model_list* list, const model_size* s, gsf__nn_config* config) {
    gsf_nn_vae vae;
    (void)s;
    memset(&vae, 0, sizeof vae);
    list->result = gsf__vae_take_config(config, &vae);
    model_add_vae(list, &vae);
}

static void model_list_features(model_list* list, const model_size* s, gsf__nn_config* config) {
    const int64_t dino[3] = {2, s->reference_tokens, s->eyes.width}, vggt[3] = {2, dino[1], 2 * dino[2]};
    const int64_t text[3] = {2, s->text_tokens, s->text.width};
    (void)config;
    model_add(list, 3, dino, "", "dino_latents");
    model_add(list, 3, vggt, "", "vggt_latents");
    model_add(list, 3, text, "", "prompt_embeds");
}

static void model_list_dinov2(model_list* list, const model_size* s, gsf__nn_config* config) {
    gsf__vit vit;
    (void)s;
    memset(&vit, 0, sizeof vit);
    list->result = gsf__dinov2_read_config(config, &vit);
    model_add_dinov2(list, &vit);
}

// The loader of VGGT takes most sizes from the tensors.
static void model_list_vggt(model_list* list, const model_size* s, gsf__nn_config* config) {
    gsf__vggt net;
    (void)config;
    memset(&net, 0, sizeof net);
    net.sizes.width = s->eyes.width;
    net.sizes.mlp = s->eyes.hidden;
    net.sizes.heads = s->eyes.heads;
    net.sizes.head_dim = s->eyes.width / s->eyes.heads;
    net.sizes.qkv_bias = 1;
    net.embed.sizes = net.sizes;
    net.embed.channels = 3;
    net.embed.patch = MODEL_PATCH;
    net.embed.grid = s->eyes_grid;
    net.embed.registers = net.registers = MODEL_REGISTERS;
    net.embed.layers = net.layers = s->eyes.layers;
    net.embed.prefix = "aggregator.patch_embed.";
    net.embed.block_names = "aggregator.patch_embed.blocks.";
    net.sizes.head_norm = 1;
    model_add_vggt(list, &net);
}

static void model_list_t5(model_list* list, const model_size* s, gsf__nn_config* config) {
    gsf_nn_t5 t5;
    (void)s;
    memset(&t5, 0, sizeof t5);
    list->result = gsf__t5_read_config(config, &t5);
    model_add_t5(list, &t5);
}

static void model_list_blip2(model_list* list, const model_size* s, gsf__nn_config* config) {
    gsf__blip net;
    gsf_nn_captioner captioner;
    (void)s;
    memset(&net, 0, sizeof net);
    memset(&captioner, 0, sizeof captioner);
    captioner.nets = &net;
    list->result = gsf__blip_read_config(config, &captioner);
    model_add_blip2(list, &net);
}

// ---- values ----------------------------------------------------------------------

GSF__BEGIN_IMPLEMENTATION // gcc inlines the library's functions only under the same rounding mode

// Values per batch, per chunk of a worker, and per block of all workers. Each is a multiple of the previous one.
enum { MODEL_BATCH = 256, MODEL_CHUNK = 1 << 15, MODEL_BLOCK = 1 << 20 };

typedef struct model_fill {
    const model_tensor* tensor;
    uint64_t seed;
    gsf_nn_dtype dtype;
    int64_t first, count; // values of the tensor
    unsigned char* out;
} model_fill;

// Four values from each random word, a batch at a time, in loops that compilers vectorize.
static void model_fill_batch(const model_fill* f, int64_t first, unsigned char out[4 * MODEL_BATCH]) {
    const float middle = (float)f->tensor->middle, step = (float)(f->tensor->spread / 32768.0);
    uint64_t words[MODEL_BATCH / 4];
    uint16_t bits[MODEL_BATCH], narrow[MODEL_BATCH];
    float values[MODEL_BATCH];
    for (int i = 0; i < MODEL_BATCH / 4; i++)
        words[i] = gsf_draw_bits(f->seed, f->tensor->stream, (uint64_t)first / 4 + (uint64_t)i);
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

static void model_fill_chunk(void* arg, size_t chunk, int32_t worker) {
    const model_fill* f = (const model_fill*)arg;
    const int64_t begin = (int64_t)chunk * MODEL_CHUNK;
    const int64_t end = begin + MODEL_CHUNK < f->count ? begin + MODEL_CHUNK : f->count;
    const size_t size = gsf_nn_get_dtype_size(f->dtype);
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
    int shards, layers; // layers 0: as configured for the size
    unsigned parts;
} model_options;

typedef struct model_writer {
    gsf_context* ctx;
    const model_options* options;
    const char* part;     // for progress messages
    const char *folder, *stem; // files are STEM.safetensors or STEM-00001-of-00002.safetensors
    int shards;
    unsigned char* block; // MODEL_BLOCK values
    double done, total;   // bytes
} model_writer;

static double model_bytes(const model_writer* w, const model_tensor* t) {
    return (double)t->count * (double)gsf_nn_get_dtype_size(w->options->dtype);
}

static int model_compare_names(const void* a, const void* b) {
    return strcmp((*(const model_tensor* const*)a)->name, (*(const model_tensor* const*)b)->name);
}

static gsf_result model_format_header(const model_writer* w, const model_tensor* const* tensors, size_t count,
                                      gsf_buffer* out) {
    const gsf_nn_dtype dtype = w->options->dtype;
    long long begin = 0;
    gsf_append_bytes(w->ctx, out, "        ", GSF__NN_FILE_HEAD); // reserved for the size of the header
    gsf_append_text(w->ctx, out, "{\"__metadata__\":{\"format\":\"pt\"}");
    for (size_t i = 0; i < count; i++) {
        const long long end = begin + (long long)tensors[i]->count * (long long)gsf_nn_get_dtype_size(dtype);
        gsf_append_text(w->ctx, out, ",\"%s\":{\"dtype\":\"%s\",\"shape\":[", tensors[i]->name,
                        gsf__nn_dtype_name(dtype));
        for (int32_t k = 0; k < tensors[i]->rank; k++)
            gsf_append_text(w->ctx, out, "%s%lld", k ? "," : "", (long long)tensors[i]->shape[k]);
        gsf_append_text(w->ctx, out, "],\"data_offsets\":[%lld,%lld]}", begin, end);
        begin = end;
    }
    gsf_append_bytes(w->ctx, out, "}", 1);
    gsf_append_bytes(w->ctx, out, "       ", (8 - out->size % 8) % 8);
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
    const size_t size = gsf_nn_get_dtype_size(fill.dtype);
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
    gsf_buffer header;
    memset(&header, 0, sizeof header);
    gsf_result result = model_format_header(w, tensors, count, &header);
    if (result == GSF_OK) result = model_write_bytes(w, file, path, header.data, header.size);
    gsf_destroy_buffer(w->ctx, &header);
    for (size_t i = 0; i < count && result == GSF_OK; i++) result = model_write_tensor(w, file, path, tensors[i]);
    return result;
}

// Writes one safetensors file with these tensors, sorted by name as in Hugging Face's writer.
static gsf_result model_write_file(model_writer* w, const char* path, const model_tensor** tensors, size_t count) {
    gsf_buffer temporary;
    memset(&temporary, 0, sizeof temporary);
    gsf_append_text(w->ctx, &temporary, "%s.tmp", path);
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
#ifdef _WIN32 // rename does not replace files there
        if (ok && result == GSF_OK) remove(path);
#endif
        if (ok && result == GSF_OK) ok = rename(temporary.data, path) == 0;
        if (!ok && result == GSF_OK)
            result = gsf_fail(w->ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, strerror(errno));
        if (result != GSF_OK) remove(temporary.data);
    }
    gsf_destroy_buffer(w->ctx, &temporary);
    return result;
}

// Consecutive tensors, with about the same number of bytes in each shard and no empty shard.
static void model_deal(const model_writer* w, model_list* list) {
    double before = 0.0;
    int shard = 0;
    for (size_t i = 0; i < list->count; i++) {
        const int left = w->shards - 1 - shard; // shards not yet started
        if (i && left > 0 && (before * w->shards >= w->total * (shard + 1) || list->count - i == (size_t)left)) shard++;
        list->tensors[i].shard = shard;
        before += model_bytes(w, &list->tensors[i]);
    }
}

static void model_print_file(const model_writer* w, int shard, gsf_buffer* out) {
    if (w->shards > 1) gsf_append_text(w->ctx, out, "%s-%05d-of-%05d.safetensors", w->stem, shard + 1, w->shards);
    else gsf_append_text(w->ctx, out, "%s.safetensors", w->stem);
}

static gsf_result model_write_text(gsf_context* ctx, const char* folder, const char* name, const char* data, size_t size) {
    gsf_buffer path;
    memset(&path, 0, sizeof path);
    gsf_append_text(ctx, &path, "%s/%s", folder, name);
    const gsf_result result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path.data, data, size);
    gsf_destroy_buffer(ctx, &path);
    return result;
}

// Writes the text and frees it.
static gsf_result model_end_text(gsf_context* ctx, const char* folder, const char* name, gsf_buffer* text) {
    const gsf_result result =
        text->failed ? GSF_ERROR_OUT_OF_MEMORY : model_write_text(ctx, folder, name, text->data, text->size);
    gsf_destroy_buffer(ctx, text);
    return result;
}

static gsf_result model_write_index(const model_writer* w, const model_tensor** sorted, size_t count) {
    gsf_buffer out;
    char name[64];
    memset(&out, 0, sizeof out);
    snprintf(name, sizeof name, "%s.safetensors.index.json", w->stem);
    gsf_append_text(w->ctx, &out, "{\n  \"metadata\": {\n    \"total_size\": %.0f\n  },\n  \"weight_map\": {\n", w->total);
    for (size_t i = 0; i < count; i++) {
        gsf_append_text(w->ctx, &out, "    \"%s\": \"", sorted[i]->name);
        model_print_file(w, sorted[i]->shard, &out);
        gsf_append_text(w->ctx, &out, "\"%s\n", i + 1 < count ? "," : "");
    }
    gsf_append_text(w->ctx, &out, "  }\n}\n");
    return model_end_text(w->ctx, w->folder, name, &out);
}

static void model_remove(const model_writer* w, const char* end) {
    gsf_buffer path;
    memset(&path, 0, sizeof path);
    gsf_append_text(w->ctx, &path, "%s/%s%s", w->folder, w->stem, end);
    if (!path.failed) remove(path.data);
    gsf_destroy_buffer(w->ctx, &path);
}

// Writes the files of a list: one file, or shards with their index. Removes files that a loader would prefer over them.
static gsf_result model_write_shards(model_writer* w, model_list* list) {
    const model_tensor** picked = (const model_tensor**)gsf_alloc(w->ctx, list->count, sizeof *picked);
    gsf_result result = picked ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (int shard = 0; shard < w->shards && result == GSF_OK; shard++) {
        gsf_buffer path;
        size_t count = 0;
        memset(&path, 0, sizeof path);
        gsf_append_text(w->ctx, &path, "%s/", w->folder);
        model_print_file(w, shard, &path);
        for (size_t i = 0; i < list->count; i++)
            if (list->tensors[i].shard == shard) picked[count++] = &list->tensors[i];
        result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : model_write_file(w, path.data, picked, count);
        gsf_destroy_buffer(w->ctx, &path);
    }
    if (result == GSF_OK && w->shards > 1) {
        for (size_t i = 0; i < list->count; i++) picked[i] = &list->tensors[i];
        qsort((void*)picked, list->count, sizeof *picked, model_compare_names);
        result = model_write_index(w, picked, list->count);
    }
    if (result == GSF_OK) model_remove(w, w->shards > 1 ? ".safetensors" : ".safetensors.index.json");
    gsf_free(w->ctx, (void*)picked);
    return result;
}

// ---- the parts -------------------------------------------------------------------

static double model_now(void) { return gsf__seconds(); }

static gsf_result model_make_folder(gsf_context* ctx, const char* path) {
    if (model_mkdir(path) == 0 || errno == EEXIST) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
}

typedef struct model_report { // the files written for one part
    const char* part;
    size_t tensors;
    double values, bytes, seconds; // bytes: without the headers
} model_report;

typedef struct model_file {
    const char* name;
    void (*print_fn)(gsf_context* ctx, const model_size* s, gsf_buffer* out);
} model_file;

typedef struct model_part {
    const char *name, *folder;
    unsigned bit;
    const char* stem; // stem of its weight files; NULL: none
    int sharded;
    void (*list_fn)(model_list* list, const model_size* s, gsf__nn_config* config);
    gsf_result (*open_fn)(gsf_context* ctx, const char* folder); // the library's loader
    model_file files[9];                                         // the first one is read by list_fn
} model_part;

// Opens the written files with the library's loader, which checks names and shapes.
#define MODEL_OPENS(net)                                                            \
    static gsf_result model_open_##net(gsf_context* ctx, const char* folder) {      \
        gsf_nn_##net net;                                                           \
        GSF__TRY(gsf_nn_load_##net(ctx, folder, &net));                             \
        gsf_nn_destroy_##net(ctx, &net);                                            \
        return GSF_OK;                                                              \
    }
MODEL_OPENS(transformer)
MODEL_OPENS(vae)
MODEL_OPENS(dinov2)
MODEL_OPENS(vggt)
MODEL_OPENS(t5)
MODEL_OPENS(tokenizer)
MODEL_OPENS(captioner)
#undef MODEL_OPENS

enum { MODEL_PARTS = 9 };
static const model_part model_parts[MODEL_PARTS] = {
    {"transformer", "/transformer", MODEL_TRANSFORMER, "diffusion_pytorch_model", 1, model_list_transformer,
     model_open_transformer, {{"config.json", model_print_transformer}}},
    {"vae", "/vae", MODEL_VAE, "diffusion_pytorch_model", 0, model_list_vae, model_open_vae,
     {{"config.json", model_print_vae}}},
    {"scheduler", "/scheduler", MODEL_SCHEDULER, NULL, 0, NULL, NULL, {{"scheduler_config.json", model_print_scheduler}}},
    {"features", "", MODEL_FEATURES, "features", 0, model_list_features, NULL, {{NULL, NULL}}},
    {"dinov2", "/dinov2", MODEL_DINOV2, "model", 0, model_list_dinov2, model_open_dinov2,
     {{"config.json", model_print_dinov2}}},
    {"vggt", "/vggt", MODEL_VGGT, "model", 0, model_list_vggt, model_open_vggt, {{"config.json", model_print_vggt}}},
    {"text", "/text_encoder", MODEL_TEXT, "model", 1, model_list_t5, model_open_t5, {{"config.json", model_print_t5}}},
    {"text", "/tokenizer", MODEL_TEXT, NULL, 0, NULL, model_open_tokenizer,
     {{"tokenizer_config.json", model_print_t5_tokenizer}, {"added_tokens.json", model_print_t5_added},
      {"spiece.model", model_print_pieces}}},
    {"blip2", "/blip2", MODEL_BLIP2, "model", 1, model_list_blip2, model_open_captioner,
     {{"config.json", model_print_blip2}, {"preprocessor_config.json", model_print_blip2_images},
      {"processor_config.json", model_print_blip2_processor}, {"generation_config.json", model_print_blip2_generation},
      {"vocab.json", model_print_vocabulary}, {"merges.txt", model_print_merges},
      {"tokenizer_config.json", model_print_blip2_tokenizer}, {"special_tokens_map.json", model_print_blip2_special},
      {"added_tokens.json", model_print_blip2_added}}},
};

// Lists the tensors of a part without writing anything; the caller frees list->tensors.
static gsf_result model_list_part(gsf_context* ctx, const model_part* part, const model_size* size, model_list* list) {
    gsf_buffer text;
    gsf__nn_config config;
    *list = model_begin_list(ctx, part->bit);
    memset(&text, 0, sizeof text);
    memset(&config, 0, sizeof config);
    if (part->files[0].print_fn) {
        part->files[0].print_fn(ctx, size, &text);
        list->result = text.failed ? GSF_ERROR_OUT_OF_MEMORY
                                   : gsf__nn_parse_config(ctx, part->files[0].name, text.data, text.size, &config);
    }
    if (list->result == GSF_OK) {
        part->list_fn(list, size, &config);
        gsf_destroy_json(ctx, &config.json);
    }
    gsf_destroy_buffer(ctx, &text);
    return list->result;
}

static gsf_result model_write_list(gsf_context* ctx, const model_options* o, const model_part* part, const char* folder,
                                   model_list* list, model_report* report) {
    model_writer w;
    const double start = model_now();
    memset(&w, 0, sizeof w);
    w.ctx = ctx;
    w.options = o;
    w.part = part->name;
    w.folder = folder;
    w.stem = part->stem;
    w.shards = part->sharded ? o->shards : 1;
    if ((size_t)w.shards > list->count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %d shards for %zu tensors", w.part, w.shards, list->count);
    for (size_t i = 0; i < list->count; i++) {
        w.total += model_bytes(&w, &list->tensors[i]);
        report->values += (double)list->tensors[i].count;
    }
    model_deal(&w, list);
    w.block = (unsigned char*)gsf_alloc(ctx, MODEL_BLOCK, gsf_nn_get_dtype_size(o->dtype));
    if (!w.block) return GSF_ERROR_OUT_OF_MEMORY;
    const gsf_result result = model_write_shards(&w, list);
    gsf_free(ctx, w.block);
    report->tensors = list->count;
    report->bytes = w.total;
    report->seconds = model_now() - start;
    return result;
}

static gsf_result model_make_part(gsf_context* ctx, const model_options* o, const model_part* part, const char* folder,
                                  model_report* report) {
    gsf_result result = model_make_folder(ctx, folder);
    report->part = part->name;
    if (result == GSF_OK && part->list_fn) {
        model_list list;
        result = model_list_part(ctx, part, o->size, &list);
        if (result == GSF_OK) result = model_write_list(ctx, o, part, folder, &list, report);
        gsf_free(ctx, list.tensors);
    }
    for (size_t i = 0; i < GSF__COUNT(part->files) && part->files[i].name && result == GSF_OK; i++) {
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        part->files[i].print_fn(ctx, o->size, &text);
        result = model_end_text(ctx, folder, part->files[i].name, &text);
    }
    return result == GSF_OK && part->open_fn ? part->open_fn(ctx, folder) : result;
}

static gsf_result model_write_pipeline(gsf_context* ctx, const char* out) {
    gsf_buffer path, text;
    void* encoder = NULL; // its config.json, if the folder has one
    size_t size;
    memset(&path, 0, sizeof path);
    memset(&text, 0, sizeof text);
    gsf_append_text(ctx, &path, "%s/text_encoder/config.json", out);
    const gsf_result result =
        path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf__nn_read_if_there(ctx, path.data, &encoder, &size);
    gsf_destroy_buffer(ctx, &path);
    if (result != GSF_OK) return result;
    model_print_pipeline(ctx, encoder != NULL, &text);
    gsf_free(ctx, encoder);
    return model_end_text(ctx, out, "model_index.json", &text);
}

// Creates the folder with the marker file that allows writing into it again.
static gsf_result model_make_out(gsf_context* ctx, const char* out) {
    static const char note[] = "Random weights, written by make_model: what they restore is noise.\n";
    gsf_buffer path;
    memset(&path, 0, sizeof path);
    gsf_append_text(ctx, &path, "%s/make_model.txt", out);
    if (path.failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = GSF_OK;
    FILE* file = NULL;
    if (model_mkdir(out) == 0) result = gsf_write_file(ctx, path.data, note, sizeof note - 1);
    else if (errno != EEXIST) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", out, strerror(errno));
    else if ((file = fopen(path.data, "rb")) == NULL)
        result = gsf_fail(ctx, GSF_ERROR_IO, "%s: is there already, and not of make_model's making (choose a new folder)", out);
    if (file) fclose(file);
    gsf_destroy_buffer(ctx, &path);
    return result;
}

// reports: MODEL_PARTS of them; the name of a part that was not requested is NULL.
static gsf_result model_make(gsf_context* ctx, const model_options* o, model_report* reports) {
    memset(reports, 0, MODEL_PARTS * sizeof *reports);
    GSF__TRY(model_make_out(ctx, o->out));
    for (int i = 0; i < MODEL_PARTS; i++) {
        if (!(o->parts & model_parts[i].bit)) continue;
        gsf_buffer folder;
        memset(&folder, 0, sizeof folder);
        gsf_append_text(ctx, &folder, "%s%s", o->out, model_parts[i].folder);
        const gsf_result result = folder.failed ? GSF_ERROR_OUT_OF_MEMORY
                                                : model_make_part(ctx, o, &model_parts[i], folder.data, &reports[i]);
        gsf_destroy_buffer(ctx, &folder);
        if (result != GSF_OK) return result;
    }
    return model_write_pipeline(ctx, o->out);
}

// ---- the program -----------------------------------------------------------------

static const char model_usage[] =
    "usage: make_model OUT [--size tiny|small|full] [--dtype f32|bf16|f16] [--seed S] [--shards N] [--threads N]\n"
    "                      [--layers N] [--parts transformer,vae,scheduler,features,dinov2,vggt,text,blip2]\n";

static gsf_context* model_context; // for the signal handler
static void model_interrupt(int number) {
    (void)number;
    gsf_request_cancel(model_context);
}

static void model_show_progress(void* user, const char* stage, double done, double total) {
    int* shown = (int*)user; // percentage last shown
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
    if (strcmp(name, "--layers") == 0) {
        const int ok = model_read_number(value, 64, &number) && number >= 1;
        if (ok) o->layers = (int)number;
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
    model_size shallow = *o.size;
    if (o.layers) {
        shallow.layers = o.layers;
        shallow.text.layers = shallow.eyes.layers = shallow.see.layers = shallow.ask.layers = shallow.tell.layers = o.layers;
        o.size = &shallow;
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
