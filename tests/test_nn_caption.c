// The captioner and its tokenizer on the small golden model: damaged and unusual files and texts, image layouts,
// workers, memory, cancellation. golden_encoders checks the values.
//     test_nn_caption encode FOLDER FILE    prints the tokens of texts for compare_bpe.py
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "blip2_folder.h"
#include "test_hooks.h"

// ---- the tokenizer -----------------------------------------------------------------

static const char small_vocabulary[] =
    "{\"a\": 0, \"b\": 1, \"ab\": 2, \"\\u0120\": 3, \"\\u0120a\": 4, \"c\": 5, \"abc\": 6, \"bc\": 7, \"aba\": 8, "
    "\"<unk>\": 9, \".\": 10}";
static const char small_config[] = "{\"unk_token\": \"<unk>\", \"bos_token\": null, \"eos_token\": null}";

static void small_folder(blip2_folder* f, gsf_context* ctx, const char* vocabulary, const char* merges,
                         const char* config) {
    blip2_open(f, ctx);
    blip2_put(f, "vocab.json", vocabulary, 0);
    blip2_put(f, "merges.txt", merges, 0);
    blip2_put(f, "tokenizer_config.json", config, 0);
    blip2_put(f, "special_tokens_map.json", NULL, 0);
    blip2_put(f, "added_tokens.json", NULL, 0);
}

static void test_bad_tokenizers(void) {
    static const char merges[] = "#version\na b\n";
    static const struct { const char *vocabulary, *merges, *config; gsf_result wanted; const char* named; } cases[] = {
        {NULL, merges, small_config, GSF_ERROR_NOT_FOUND, "vocab.json"},
        {small_vocabulary, NULL, small_config, GSF_ERROR_NOT_FOUND, "merges.txt"},
        {"[1]", merges, small_config, GSF_ERROR_FORMAT, "vocab.json:0: not an object"},
        {"{}", merges, small_config, GSF_ERROR_FORMAT, "0 tokens"},
        {"{\"a\": 1, \"b\": 2, \"ab\": 4294967296}", merges, small_config, GSF_ERROR_FORMAT, "the id of ab"},
        {"{\"a\": 1, \"b\": 1e300, \"ab\": 4}", merges, small_config, GSF_ERROR_FORMAT, "vocab.json:14: the id of b"},
        {"{\"a\": 1, \"b\": -1, \"ab\": 4}", merges, small_config, GSF_ERROR_FORMAT, "the id of b"},
        {"{\"a\": 1, \"b\": 1.5, \"ab\": 4}", merges, small_config, GSF_ERROR_FORMAT, "the id of b"},
        {"{\"a\": 1, \"b\": \"2\", \"ab\": 4}", merges, small_config, GSF_ERROR_FORMAT, "the id of b"},
        {"{\"a\": 1, \"a\": 2}", merges, small_config, GSF_ERROR_FORMAT, "key \"a\" occurs twice"},
        {"{\"a\": 1, \"b\": 1, \"ab\": 4}", merges, small_config, GSF_ERROR_FORMAT, "both have the id 1"},
        {"{\"a\": 1, \"\": 2}", merges, small_config, GSF_ERROR_FORMAT, "an empty token"},
        {"{\"a\xff\": 1}", merges, small_config, GSF_ERROR_FORMAT, "vocab.json:3: expected UTF-8"},
        {"{\"a\": 1,", merges, small_config, GSF_ERROR_FORMAT, "vocab.json:8"},
        {small_vocabulary, "#\na\n", small_config, GSF_ERROR_FORMAT, "merges.txt:2: 1 tokens, not two"},
        {small_vocabulary, "#\n\na b\na b c\n", small_config, GSF_ERROR_FORMAT, "merges.txt:4: 3 tokens, not two"},
        {small_vocabulary, "#\r\na b\r\nab z\r\n", small_config, GSF_ERROR_FORMAT, "merges.txt:3: z is not in vocab.json"},
        {small_vocabulary, "#\nb a\n", small_config, GSF_ERROR_FORMAT, "merges.txt:2: ba is not in vocab.json"},
        {small_vocabulary, "#\n\xff b\n", small_config, GSF_ERROR_FORMAT, "merges.txt:2: ? is not in vocab.json"},
        {small_vocabulary, merges, "[]", GSF_ERROR_FORMAT, "tokenizer_config.json:0: not an object"},
        {small_vocabulary, merges, "{\"errors\": \"strict\"}", GSF_ERROR_UNSUPPORTED, "errors"},
        {small_vocabulary, merges, "{\"add_bos_token\": 1}", GSF_ERROR_FORMAT, "add_bos_token is not true or false"},
        {small_vocabulary, merges, "{\"add_bos_token\": true, \"bos_token\": null}", GSF_ERROR_FORMAT, "no bos_token"},
        {small_vocabulary, merges, "{\"bos_token\": 5}", GSF_ERROR_FORMAT, "tokenizer_config.json:14: not a token"},
        {small_vocabulary, merges, "{\"bos_token\": {\"content\": \"\"}}", GSF_ERROR_FORMAT, "not a token"},
        {small_vocabulary, merges, "{\"bos_token\": {\"content\": \"x\", \"single_word\": true}}", GSF_ERROR_UNSUPPORTED,
         "single_word of token x"},
        {small_vocabulary, merges, "{\"additional_special_tokens\": {}}", GSF_ERROR_FORMAT, "is not an array"},
        {small_vocabulary, merges, "{\"added_tokens_decoder\": []}", GSF_ERROR_FORMAT, "are not an object"},
        {small_vocabulary, merges, "{\"added_tokens_decoder\": {\"99999999999\": \"x\"}}", GSF_ERROR_FORMAT, "id from 0"},
        {small_vocabulary, merges, "{\"added_tokens_decoder\": {\"-1\": \"x\"}}", GSF_ERROR_FORMAT, "id from 0"},
        {small_vocabulary, merges, "{\"added_tokens_decoder\": {\"20\": \"x\", \"21\": \"x\"}}", GSF_ERROR_FORMAT,
         "x is added twice"},
        {small_vocabulary, merges, "{\"added_tokens_decoder\": {\"20\": \"x\", \"020\": \"y\"}}", GSF_ERROR_FORMAT,
         "both have the id 20"}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        blip2_folder f;
        gsf_context ctx;
        gsf_nn_bpe bpe;
        small_folder(&f, &ctx, cases[i].vocabulary, cases[i].merges, cases[i].config);
        CHECK_RESULT(&ctx, gsf_nn_load_bpe(&ctx, blip2_golden(), &bpe), cases[i].wanted);
        if (!CHECK(strstr(ctx.error, cases[i].named) != NULL)) fprintf(stderr, "    %zu: %s\n", i, ctx.error);
        CHECK(bpe.tables == NULL);
    }
}

static int same_ids(gsf_context* ctx, const gsf_nn_bpe* bpe, const char* text, const int32_t* expected, size_t count) {
    int32_t* ids = NULL;
    size_t found = 0;
    CHECK_OK(ctx, gsf_nn_encode_bpe(ctx, bpe, text, strlen(text), 0, &ids, &found));
    const int same = found == count && (count == 0 || memcmp(ids, expected, count * sizeof *ids) == 0);
    for (size_t i = 0; !same && i < found; i++) fprintf(stderr, "%s%d", i ? ", " : "    ", (int)ids[i]);
    gsf_free(ctx, ids);
    return same;
}

#define CHECK_IDS(text, ...)                                                                       \
    do {                                                                                           \
        static const int32_t expected[] = {__VA_ARGS__};                                           \
        CHECK(same_ids(&ctx, &bpe, text, expected, sizeof expected / sizeof *expected));           \
    } while (0)

// Ranks that training would never produce: a merge whose result is part of a merge of lower rank. As in GPT2Tokenizer,
// all pairs of one rank are merged before any pair that these merges make possible. Expected ids are from
// GPT2Tokenizer.
static void test_small_tokenizer(void) {
    blip2_folder f;
    gsf_context ctx;
    gsf_nn_bpe bpe;
    int32_t* ids;
    size_t count;
    small_folder(&f, &ctx, small_vocabulary, "ignored\nab a\nab c\na b\nb c\nb c\n", small_config);
    if (!CHECK_OK(&ctx, gsf_nn_load_bpe(&ctx, blip2_golden(), &bpe))) return;
    CHECK(bpe.bos == -1 && bpe.eos == -1 && bpe.unk == 9 && bpe.highest_id == 10);
    CHECK_IDS("abab", 2, 2);
    CHECK_IDS("aba", 8);
    CHECK_IDS("abcbc", 6, 7);
    CHECK_IDS("a a", 0, 3, 0);
    CHECK_IDS("z<unk>a", 9, 9, 0);
    CHECK(same_ids(&ctx, &bpe, "", NULL, 0));
    gsf_nn_destroy_bpe(&ctx, &bpe);
    small_folder(&f, &ctx, small_vocabulary, "\na b\n\xc4\xa0 a\nb c", // the last line lacks a line feed and is ignored
                 "{\"unk_token\": null, \"bos_token\": {\"content\": \"new\", \"lstrip\": true, \"rstrip\": true}, "
                 "\"eos_token\": \"<end>\", \"add_bos_token\": true, \"add_prefix_space\": true, "
                 "\"clean_up_tokenization_spaces\": true}");
    if (!CHECK_OK(&ctx, gsf_nn_load_bpe(&ctx, blip2_golden(), &bpe))) return;
    CHECK(bpe.bos == 11 && bpe.eos == 12 && bpe.unk == -1 && bpe.pad == -1 && bpe.highest_id == 12);
    CHECK_IDS("a", 11, 4);
    CHECK_IDS("abc", 11, 3, 2, 5);
    CHECK_IDS("a \t new\n b<end>", 11, 4, 11, 1, 12);
    CHECK_RESULT(&ctx, gsf_nn_encode_bpe(&ctx, &bpe, "a z", 3, 0, &ids, &count), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx.error, "0x7a") != NULL && ids == NULL && count == 0);
    static const int32_t tidy[] = {0, 3, 10, 1, 77, 11, -5, 12};
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    CHECK_OK(&ctx, gsf_nn_decode_bpe(&ctx, &bpe, tidy, 8, 1, &text));
    CHECK(text.size == 3 && strcmp(text.data, "a.b") == 0);
    CHECK_OK(&ctx, gsf_nn_decode_bpe(&ctx, &bpe, tidy, 8, 0, &text)); // appends
    CHECK(strcmp(text.data, "a.ba.bnew<end>") == 0);
    gsf_destroy_buffer(&ctx, &text);
    gsf_nn_destroy_bpe(&ctx, &bpe);
}

static void check_round_trip(gsf_context* ctx, const gsf_nn_bpe* bpe, const char* text, size_t size) {
    int32_t* ids = NULL;
    size_t count = 0;
    gsf_buffer back;
    memset(&back, 0, sizeof back);
    CHECK_OK(ctx, gsf_nn_encode_bpe(ctx, bpe, text, size, 1, &ids, &count));
    CHECK(count <= size);
    CHECK_OK(ctx, gsf_nn_decode_bpe(ctx, bpe, ids, count, 0, &back));
    if (!CHECK(back.size == size && (!size || memcmp(back.data, text, size) == 0)))
        fprintf(stderr, "    %.40s\n", text);
    gsf_destroy_buffer(ctx, &back);
    gsf_free(ctx, ids);
}

static void test_odd_texts(void) {
    static const struct { const char* text; size_t size; } texts[] = {
        {"", 0}, {" ", 1}, {"\n\r\t \v\f", 6}, {"\0\1\2\x7f", 4}, {"a\0b", 3},
        {"\xf0\x9f\x91\xa9\xe2\x80\x8d\xf0\x9f\x91\xa6", 11}, {"\xef\xbf\xbd\xef\xbb\xbf", 6},
        {"\xc2\x80\xc2\xa0\xc2\xad", 6}, {"e\xcc\x81\xe3\x80\x80 \xd7\x90\xe0\xa4\x95", 12},
        {"\xf4\x8f\xbf\xbf\xee\x80\x80", 7}, {"don't 've  ''d   'll\n\n x", 23}, {"</s", 3}};
    static const struct { const char* text; size_t size, at; } bad[] = {
        {"\xff", 1, 0}, {"ab\xc3", 3, 2}, {"\xed\xa0\x80", 3, 0}, {"x\xc0\x80", 3, 1}, {"\xf4\x90\x80\x80", 4, 0},
        {"\xe3\x80\x80\x80", 4, 3}};
    static const char* const parts[] = {"a", " ", "\xc3\xa9", "ab ", "'s", "\xf0\x9f\x98\x80", "\n", "the 12 "};
    gsf_context ctx;
    gsf_nn_bpe bpe;
    test_context_init(&ctx);
    if (!CHECK_OK(&ctx, gsf_nn_load_bpe(&ctx, blip2_golden(), &bpe))) return;
    for (size_t i = 0; i < sizeof texts / sizeof *texts; i++) check_round_trip(&ctx, &bpe, texts[i].text, texts[i].size);
    check_round_trip(&ctx, &bpe, NULL, 0);
    const size_t most = 1 << 20;
    char* text = (char*)malloc(most);
    for (size_t i = 0; i < sizeof parts / sizeof *parts; i++) { // would take seconds if merging a word were quadratic
        const size_t step = strlen(parts[i]), size = (i < 3 ? most : most / 8) / step * step;
        for (size_t k = 0; k < size; k += step) memcpy(text + k, parts[i], step);
        check_round_trip(&ctx, &bpe, text, size);
    }
    free(text);
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        int32_t* ids;
        size_t count;
        char place[32];
        snprintf(place, sizeof place, "text:%zu:", bad[i].at);
        CHECK_RESULT(&ctx, gsf_nn_encode_bpe(&ctx, &bpe, bad[i].text, bad[i].size, 0, &ids, &count),
                     GSF_ERROR_INVALID_ARGUMENT);
        CHECK(strstr(ctx.error, place) == ctx.error && ids == NULL);
    }
    gsf_nn_destroy_bpe(&ctx, &bpe);
}

// Bytes that are not valid UTF-8 decode as in Python's bytes.decode(errors="replace") ('?'), with a vocabulary in which
// a byte's id is the byte itself.
static void test_broken_bytes(void) {
    static const struct { const char *bytes, *text; } cases[] = {
        {"\x80", "?"}, {"\xc3", "?"}, {"a\xe3\x81z", "a?z"}, {"\xe3\xc3\xa9", "?\xc3\xa9"}, {"\xf0\x9f\x98", "?"},
        {"\xf0\x9fz", "?z"}, {"\xed\xa0\x80", "???"}, {"\xe0\x80\x80", "???"}, {"\xf4\x90\x80\x80", "????"},
        {"\xf8\x88", "??"}, {"\xc0\xaf", "??"}, {"\xf0\x8f", "??"},
        {"\xf1\x80\x80\xf1\x80\x80\x80", "?\xf1\x80\x80\x80"}};
    char vocabulary[8192] = "{";
    uint32_t next = 256;
    for (uint32_t b = 0; b < 256; b++) {
        const int printed = (b > 32 && b < 127) || (b > 160 && b != 173);
        sprintf(vocabulary + strlen(vocabulary), "%s\"\\u%04x\": %u", b ? ", " : "", (unsigned)(printed ? b : next++),
                (unsigned)b);
    }
    strcat(vocabulary, "}");
    blip2_folder f;
    gsf_context ctx;
    gsf_nn_bpe bpe;
    small_folder(&f, &ctx, vocabulary, "", "{\"unk_token\": null, \"bos_token\": null, \"eos_token\": null}");
    if (!CHECK_OK(&ctx, gsf_nn_load_bpe(&ctx, blip2_golden(), &bpe))) return;
    CHECK_IDS("a \xc3\xad\n", 'a', ' ', 0xc3, 0xad, '\n');
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        int32_t ids[8];
        size_t count = 0, at = 0;
        gsf_buffer text;
        for (const char* b = cases[i].bytes; *b; b++) ids[count++] = (unsigned char)*b;
        memset(&text, 0, sizeof text);
        CHECK_OK(&ctx, gsf_nn_decode_bpe(&ctx, &bpe, ids, count, 0, &text));
        int same = 1;
        for (const char* p = cases[i].text; *p && same; p++) {
            const char* wanted = *p == '?' ? "\xef\xbf\xbd" : p;
            const size_t step = *p == '?' ? 3 : 1;
            same = at + step <= text.size && memcmp(text.data + at, wanted, step) == 0;
            at += step;
        }
        if (!CHECK(same && at == text.size)) fprintf(stderr, "    case %zu\n", i);
        gsf_destroy_buffer(&ctx, &text);
    }
    gsf_nn_destroy_bpe(&ctx, &bpe);
}

// ---- the captioner: model folders -----------------------------------------------------

static void test_bad_configs(void) {
    static const struct { const char *file, *from, *to; gsf_result wanted; const char* named; } cases[] = {
        {"config.json", "\"do_layer_norm_before\": true", "\"do_layer_norm_before\": false", GSF_ERROR_UNSUPPORTED,
         "do_layer_norm_before"},
        {"config.json", "\"model_type\": \"opt\"", "\"model_type\": \"t5\"", GSF_ERROR_UNSUPPORTED, "t5"},
        {"config.json", "\"word_embed_proj_dim\": ", "\"word_embed_proj_dim\": 1", GSF_ERROR_UNSUPPORTED,
         "word_embed_proj_dim"},
        {"config.json", "\"relu\"", "\"relu6\"", GSF_ERROR_UNSUPPORTED, "activation_function is relu6"},
        {"config.json", "\"absolute\"", "\"relative_key\"", GSF_ERROR_UNSUPPORTED, "position_embedding_type"},
        {"config.json", "\"num_attention_heads\": 2", "\"num_attention_heads\": 7", GSF_ERROR_UNSUPPORTED, "7 heads"},
        {"config.json", "\"vision_config\": {", "\"vision_config\": 5, \"old\": {", GSF_ERROR_FORMAT, "vision_config"},
        {"config.json", "\"vocab_size\": 392", "\"vocab_size\": 391", GSF_ERROR_FORMAT, "embed_tokens.weight has shape"},
        {"config.json", "\"patch_size\": 14", "\"patch_size\": 100", GSF_ERROR_FORMAT, "patch_size"},
        {"config.json", "\"num_query_tokens\": 4", "\"num_query_tokens\": -4", GSF_ERROR_FORMAT, "num_query_tokens"},
        {"config.json", "\"cross_attention_frequency\": 2", "\"cross_attention_frequency\": 3", GSF_ERROR_FORMAT,
         "layer.3.crossattention"},
        {"config.json", "\"qkv_bias\": true", "\"qkv_bias\": false", GSF_ERROR_FORMAT, "qkv.bias"},
        {"config.json", "\"enable_bias\": true", "\"enable_bias\": false", GSF_ERROR_UNSUPPORTED, "enable_bias"},
        {"preprocessor_config.json", "\"resample\": 3", "\"resample\": 0", GSF_ERROR_FORMAT, "resample"},
        {"preprocessor_config.json", "\"height\": 56", "\"height\": 57", GSF_ERROR_UNSUPPORTED, "56 x 57"},
        {"preprocessor_config.json", "\"do_normalize\": true", "\"do_normalize\": false", GSF_ERROR_UNSUPPORTED,
         "do_normalize"},
        {"preprocessor_config.json", "0.26862954", "0.0", GSF_ERROR_FORMAT, "image_std"},
        {"config.json", NULL, NULL, GSF_ERROR_NOT_FOUND, "config.json"},
        {"preprocessor_config.json", NULL, NULL, GSF_ERROR_NOT_FOUND, "preprocessor_config.json"},
        {"vocab.json", NULL, NULL, GSF_ERROR_NOT_FOUND, "vocab.json"},
        {"model.safetensors", NULL, NULL, GSF_ERROR_NOT_FOUND, "model.safetensors"}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        blip2_folder f;
        gsf_context ctx;
        gsf_nn_captioner net;
        char* text = cases[i].from ? blip2_edit(cases[i].file, cases[i].from, cases[i].to) : NULL;
        blip2_open(&f, &ctx);
        blip2_put(&f, cases[i].file, text, 0);
        CHECK_RESULT(&ctx, gsf_nn_load_captioner(&ctx, blip2_golden(), &net), cases[i].wanted);
        if (!CHECK(strstr(ctx.error, cases[i].named) != NULL)) fprintf(stderr, "    %zu: %s\n", i, ctx.error);
        CHECK(net.nets == NULL && net.weights.tensors == NULL);
        free(text);
    }
}

static gsf_image make_photo(gsf_context* ctx) {
    gsf_image image;
    uint64_t state = 11;
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, 37, 29, 3, &image));
    for (int i = 0; i < 37 * 29 * 3; i++) ((uint8_t*)image.data)[i] = (uint8_t)test_random_bits(&state);
    return image;
}

// Weights changed one at a time; kind 0: missing, 1: unexpected, 2: containing a NaN.
static void test_bad_weights(void) {
    static const struct { const char* name; int kind; } cases[] = {
        {"query_tokens", 0}, {"qformer.encoder.layer.0.crossattention.output.LayerNorm.bias", 0},
        {"language_model.model.decoder.layers.1.fc2.bias", 0}, {"vision_model.post_layernorm.weight", 0},
        {"vision_model.head.weight", 1}, {"vision_model.embeddings.patch_embedding.bias", 2},
        {"vision_model.encoder.layers.1.mlp.fc1.weight", 2}, {"qformer.encoder.layer.1.output_query.dense.weight", 2},
        {"language_projection.bias", 2}, {"language_model.model.decoder.layers.0.self_attn.v_proj.weight", 2},
        {"language_model.model.decoder.final_layer_norm.bias", 2}};
    static const float ones[2] = {1.0f, 1.0f};
    static const int64_t two[1] = {2};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) {
        blip2_folder f;
        gsf_context ctx;
        gsf_nn_weights w;
        gsf_nn_captioner net;
        size_t count = 0, size;
        blip2_open(&f, &ctx);
        CHECK_OK(&f.plain, gsf_nn_load_weights(&f.plain, blip2_golden(), "model", &w));
        gsf_nn_tensor* tensors = (gsf_nn_tensor*)malloc((w.tensor_count + 1) * sizeof *tensors);
        float* poisoned = NULL;
        for (size_t k = 0; k < w.tensor_count; k++) {
            const int named = strcmp(w.tensors[k].name, cases[i].name) == 0;
            if (named && cases[i].kind == 0) continue;
            tensors[count++] = w.tensors[k];
            if (!named) continue;
            poisoned = (float*)malloc((size_t)w.tensors[k].count * sizeof(float));
            gsf_nn_convert_tensor(&w.tensors[k], 0, w.tensors[k].count, poisoned);
            poisoned[w.tensors[k].count / 2] = NAN;
            tensors[count - 1].data = poisoned;
            tensors[count - 1].dtype = GSF_NN_F32;
        }
        if (cases[i].kind == 1) tensors[count++] = gsf_nn_wrap_tensor(cases[i].name, ones, 1, two);
        CHECK_OK(&f.plain, gsf_nn_save_tensors(&f.plain, test_scratch("edited.safetensors"), tensors, count));
        gsf_nn_destroy_weights(&f.plain, &w);
        char* bytes = test_read_file(test_scratch("edited.safetensors"), &size);
        blip2_put(&f, "model.safetensors.index.json", NULL, 0);
        blip2_put(&f, "model.safetensors", bytes, size);
        const gsf_result wanted = cases[i].kind == 2 ? GSF_OK : GSF_ERROR_FORMAT;
        CHECK_RESULT(&ctx, gsf_nn_load_captioner(&ctx, blip2_golden(), &net), wanted);
        if (cases[i].kind == 2) {
            gsf_image photo = make_photo(&ctx);
            char caption[64] = "before";
            CHECK_RESULT(&ctx, gsf_nn_caption_image(&ctx, &net, &photo, NULL, 2, caption, sizeof caption),
                         GSF_ERROR_NUMERIC);
            CHECK(caption[0] == 0);
            gsf_destroy_image(&ctx, &photo);
            gsf_nn_destroy_captioner(&ctx, &net);
        }
        if (!CHECK(strstr(ctx.error, cases[i].name) != NULL)) fprintf(stderr, "    %s: %s\n", cases[i].name, ctx.error);
        free(bytes);
        free(tensors);
        free(poisoned);
    }
}

// ---- the captioner: calls --------------------------------------------------------------

static void test_arguments(gsf_context* ctx, const gsf_nn_captioner* net, const gsf_image* photo) {
    char caption[256], whole[1024];
    static const struct { const char* prompt; int32_t most; const char* named; } bad[] = {
        {NULL, -1, "max_new_tokens"}, {NULL, INT32_MAX, "positions"}, {NULL, 1000000, "positions"},
        {"\xff", 0, "text:0"}, {"a <image> of", 0, "contains the image token"}};
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        strcpy(caption, "before");
        CHECK_RESULT(ctx, gsf_nn_caption_image(ctx, net, photo, bad[i].prompt, bad[i].most, caption, sizeof caption),
                     GSF_ERROR_INVALID_ARGUMENT);
        if (!CHECK(strstr(ctx->error, bad[i].named) != NULL && caption[0] == 0)) fprintf(stderr, "    %s\n", ctx->error);
    }
    CHECK_RESULT(ctx, gsf_nn_caption_image(ctx, net, NULL, NULL, 0, caption, sizeof caption),
                 GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_nn_caption_image(ctx, net, photo, NULL, 0, caption, 0), GSF_ERROR_INVALID_ARGUMENT);
    gsf_image empty;
    memset(&empty, 0, sizeof empty);
    CHECK_RESULT(ctx, gsf_nn_caption_image(ctx, net, &empty, NULL, 0, caption, sizeof caption),
                 GSF_ERROR_INVALID_ARGUMENT);
    CHECK_OK(ctx, gsf_nn_caption_image(ctx, net, photo, "a photo of", 12, whole, sizeof whole));
    const size_t size = strlen(whole);
    CHECK(size > 0);
    for (size_t room = 1; room <= size + 1; room++) { // expects the longest prefix of whole characters that fits
        CHECK_OK(ctx, gsf_nn_caption_image(ctx, net, photo, "a photo of", 12, caption, room));
        const size_t kept = strlen(caption);
        CHECK(kept < room && memcmp(caption, whole, kept) == 0 && ((unsigned char)whole[kept] & 0xc0) != 0x80);
        if (room > 12 && room < size) room = size - 1;
    }
    CHECK(strcmp(caption, whole) == 0);
    double bytes[2], flops[2];
    gsf__nn_query_captioner(net, 0, 0, &bytes[0], &flops[0]);
    gsf__nn_query_captioner(net, 9, 20, &bytes[1], &flops[1]);
    CHECK(bytes[0] > 0.0 && flops[0] > 0.0 && flops[1] > flops[0] && bytes[1] >= bytes[0]);
}

// The same image as floats, with an alpha channel, stored bottom-up.
static void test_image_kinds(gsf_context* ctx, const gsf_nn_captioner* net, const gsf_image* photo) {
    char expected[512], caption[512];
    CHECK_OK(ctx, gsf_nn_caption_image(ctx, net, photo, NULL, 0, expected, sizeof expected));
    for (int kind = 0; kind < 3; kind++) {
        gsf_image image;
        const gsf_dtype dtype = kind == 0 ? GSF_F32 : GSF_U8;
        CHECK_OK(ctx, gsf_make_image(ctx, dtype, photo->width, photo->height, kind == 1 ? 4 : 3, &image));
        for (int64_t y = 0; y < photo->height; y++)
            for (int64_t x = 0; x < photo->width; x++)
                for (int64_t c = 0; c < 3; c++) {
                    const uint8_t v = ((const uint8_t*)photo->data)[y * photo->stride_y + x * photo->stride_x + c];
                    const int64_t row = kind == 2 ? photo->height - 1 - y : y;
                    char* to = (char*)image.data + row * image.stride_y + x * image.stride_x + c * image.stride_c;
                    const float as_float = (float)v / 255.0f;
                    if (kind == 0) memcpy(to, &as_float, sizeof as_float);
                    else *(uint8_t*)to = v;
                }
        gsf_image view = image;
        if (kind == 2) {
            view.data = (char*)image.data + (image.height - 1) * image.stride_y;
            view.stride_y = -image.stride_y;
        }
        CHECK_OK(ctx, gsf_nn_caption_image(ctx, net, &view, NULL, 0, caption, sizeof caption));
        if (!CHECK(strcmp(caption, expected) == 0)) fprintf(stderr, "    kind %d\n", kind);
        gsf_destroy_image(ctx, &image);
    }
}

typedef struct seen { uint64_t sum; int stages; } seen; // checksum of the bits of all intermediates

static void sum_tap(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns) {
    seen* s = (seen*)user;
    (void)name;
    (void)index;
    for (int64_t i = 0; i < rows * columns; i++) {
        uint32_t bits;
        memcpy(&bits, &data[i], sizeof bits);
        s->sum = (s->sum ^ bits) * 0x100000001b3u;
    }
    s->stages++;
}

typedef struct watcher { gsf_context* ctx; double stop_at, last, total; int calls; } watcher;

static void watch_progress(void* user, const char* stage, double done, double total) {
    watcher* w = (watcher*)user;
    CHECK(strcmp(stage, "caption") == 0 && done >= w->last && done <= total);
    w->last = done;
    w->total = total;
    w->calls++;
    if (w->stop_at > 0.0 && done >= w->stop_at) gsf_request_cancel(w->ctx);
}

// Workers, progress, cancellation at every step, and failure of every allocation.
static void test_runs(const gsf_image* photo) {
    seen sums[2];
    memset(sums, 0, sizeof sums);
    for (int k = 0; k < 2; k++) {
        gsf_context ctx;
        gsf_nn_captioner net;
        gsf__nn_caption_desc d;
        watcher w;
        int32_t* ids;
        size_t count;
        test_context_zero(&ctx);
        if (k) work_backwards(&ctx);
        memset(&w, 0, sizeof w);
        w.ctx = &ctx;
        ctx.progress.progress_fn = watch_progress;
        ctx.progress.user = &w;
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        if (!CHECK_OK(&ctx, gsf_nn_load_captioner(&ctx, blip2_golden(), &net))) return;
        memset(&d, 0, sizeof d);
        d.image = photo;
        d.max_new_tokens = 3;
        const gsf__nn_tap tap = {sum_tap, &sums[k]};
        d._tap = &tap;
        CHECK_OK(&ctx, gsf__nn_caption_ids(&ctx, &net, &d, &ids, &count));
        for (size_t i = 0; i < count; i++) sums[k].sum = (sums[k].sum ^ (uint64_t)ids[i]) * 0x100000001b3u;
        gsf_free(&ctx, ids);
        CHECK(sums[k].stages == 5 && w.last == w.total && w.calls > 3);
        const double steps = w.total;
        d._tap = NULL;
        for (double stop = 1.0; stop < steps && k == 0; stop += 1.0) {
            w.last = 0.0;
            w.stop_at = stop;
            CHECK_RESULT(&ctx, gsf__nn_caption_ids(&ctx, &net, &d, &ids, &count), GSF_ERROR_CANCELLED);
            CHECK(ids == NULL && count == 0 && w.last == stop);
            gsf_clear_cancel(&ctx);
        }
        gsf_nn_destroy_captioner(&ctx, &net);
    }
    CHECK(sums[0].sum == sums[1].sum);
}

static void test_memory(const gsf_image* photo) {
    for (size_t fail = 1;; fail++) {
        counter c = {0};
        gsf_context ctx;
        gsf_nn_captioner net;
        char caption[256];
        test_context_zero(&ctx);
        count_memory(&ctx, &c);
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        c.fail_at = fail;
        gsf_result result = gsf_nn_load_captioner(&ctx, blip2_golden(), &net);
        if (!result) {
            result = gsf_nn_caption_image(&ctx, &net, photo, "a", 2, caption, sizeof caption);
            gsf_nn_destroy_captioner(&ctx, &net);
        }
        CHECK(c.live == 0);
        if (c.calls < fail) {
            CHECK(result == GSF_OK && fail > 20);
            return;
        }
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) fprintf(stderr, "    call %zu: %s\n", fail, ctx.error);
    }
}

// ---- for compare_bpe.py: records of a 32-bit size and that many bytes -----------------------

static int encode_file(const char* from, const char* path) {
    gsf_context ctx;
    gsf_nn_bpe bpe;
    size_t size, count;
    char* data = test_read_file(path, &size);
    test_context_init(&ctx);
    if (gsf_nn_load_bpe(&ctx, from, &bpe) != GSF_OK) {
        fprintf(stderr, "%s\n", ctx.error);
        return 1;
    }
    for (size_t at = 0; at + 4 <= size;) {
        uint32_t length;
        int32_t* ids;
        memcpy(&length, data + at, 4);
        if (gsf_nn_encode_bpe(&ctx, &bpe, data + at + 4, length, 0, &ids, &count) != GSF_OK) printf("%s", ctx.error);
        for (size_t i = 0; i < count; i++) printf("%d ", (int)ids[i]);
        for (int skip = 0; skip < 2; skip++) {
            gsf_buffer text;
            memset(&text, 0, sizeof text);
            if (gsf_nn_decode_bpe(&ctx, &bpe, ids, count, skip, &text) != GSF_OK) return 1;
            putchar('|');
            for (size_t i = 0; i < text.size; i++) printf("%02x", (unsigned)(unsigned char)text.data[i]);
            gsf_destroy_buffer(&ctx, &text);
        }
        putchar('\n');
        gsf_free(&ctx, ids);
        at += 4 + (size_t)length;
    }
    gsf_nn_destroy_bpe(&ctx, &bpe);
    free(data);
    return 0;
}

int main(int argc, char** argv) {
    if (argc == 4 && strcmp(argv[1], "encode") == 0) return encode_file(argv[2], argv[3]);
    gsf_context ctx;
    gsf_nn_captioner net;
    test_context_init(&ctx);
    test_bad_tokenizers();
    test_small_tokenizer();
    test_odd_texts();
    test_broken_bytes();
    test_bad_configs();
    test_bad_weights();
    if (CHECK_OK(&ctx, gsf_nn_load_captioner(&ctx, blip2_golden(), &net))) {
        gsf_image photo = make_photo(&ctx);
        test_arguments(&ctx, &net, &photo);
        test_image_kinds(&ctx, &net, &photo);
        test_runs(&photo);
        test_memory(&photo);
        gsf_destroy_image(&ctx, &photo);
        gsf_nn_destroy_captioner(&ctx, &net);
    }
    return test_report();
}
