// encoders_blip2.h - the BLIP-2 captioner and its tokenizer against the float64 run of transformers.
#ifndef ENCODERS_BLIP2_H
#define ENCODERS_BLIP2_H

#include "blip2_folder.h"
#include "encoders_golden.h"

// Tolerances. Measured errors: 0, 2e-6, 2e-6, 5e-6, 5e-6, for values of about 1.
static const struct { const char *tap, *expected; double bar; } blip2_stages[] = {
    {"pixel_values", "pixel_values", 0.0}, {"vision", "vision_last", 4e-5}, {"qformer", "qformer_last", 4e-5},
    {"projection", "language_projection", 4e-5}, {"logits", "logits_prompt", 4e-5}};

typedef struct blip2_case {
    gsf_context* ctx;
    test_tensors expected;
    char label[64]; // "case0"
    const char* run; // "no_prompt"
    int seen;
} blip2_case;

static void see_blip2_tap(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns) {
    (void)index;
    blip2_case* c = (blip2_case*)user;
    for (size_t i = 0; i < sizeof blip2_stages / sizeof *blip2_stages; i++) {
        if (strcmp(blip2_stages[i].tap, name) != 0) continue;
        char whole[160];
        const int of_run = strcmp(name, "logits") == 0;
        snprintf(whole, sizeof whole, "%s.%s%s%s", c->label, of_run ? c->run : "", of_run ? "." : "",
                 blip2_stages[i].expected);
        test_tensor t = test_find_tensor(&c->expected, whole);
        if (!t.v) return;
        if (CHECK(t.count == (size_t)(rows * columns)))
            check_rows(whole, data, rows, columns, columns, t.v, columns, blip2_stages[i].bar);
        c->seen++;
        test_free_tensor(&t);
    }
}

// Numbers of a JSON list from index `skip` on; -1 past its end.
static int32_t blip2_id(const gsf_json* json, const gsf_json_value* list, size_t index) {
    const gsf_json_value* value = gsf_find_json_element(json, list, index);
    return value ? (int32_t)value->number : -1;
}

static void check_blip2_ids(const char* what, const gsf_json* json, const gsf_json_value* list, size_t skip,
                            const int32_t* ids, size_t count) {
    if (!CHECK(list != NULL)) return;
    int same = list->count == count + skip;
    for (size_t i = 0; i < count && same; i++) same = blip2_id(json, list, skip + i) == ids[i];
    if (!test_check(same, what, __FILE__, __LINE__))
        fprintf(stderr, "    %zu ids of %zu, the first %d\n", count, (size_t)list->count - skip, count ? (int)ids[0] : -1);
}

static size_t blip2_strip(const char** text, size_t size) { // ASCII white space is enough here
    while (size && (**text == ' ' || (**text >= 9 && **text <= 13) || (**text >= 28 && **text <= 31))) (*text)++, size--;
    for (const char* t = *text; size; size--) {
        const char c = t[size - 1];
        if (!(c == ' ' || (c >= 9 && c <= 13) || (c >= 28 && c <= 31))) break;
    }
    return size;
}

// The text of a caption, with U+FFFD in place of a zero byte.
static void check_blip2_text(const gsf_json_value* expected, const char* caption) {
    const char* text = expected->string;
    const size_t size = blip2_strip(&text, expected->string_size);
    size_t at = 0;
    int same = 1;
    for (size_t i = 0; i < size && same; i++) {
        const char* next = text[i] ? text + i : "\xef\xbf\xbd";
        const size_t step = text[i] ? 1 : 3;
        same = strncmp(caption + at, next, step) == 0;
        at += step;
    }
    CHECK(same && caption[at] == 0);
}

static void check_blip2_run(blip2_case* c, const gsf_nn_captioner* net, const gsf_image* image, const gsf_json* json,
                            const gsf_json_value* expected) {
    const gsf_json_value* prompt = gsf_find_json_member(json, expected, "prompt");
    const gsf_json_value* inputs = gsf_find_json_member(json, expected, "input_ids");
    const gsf_json_value* usual = gsf_find_json_member(json, expected, "hf_generate_default");
    gsf__nn_caption_desc d;
    int32_t* ids;
    size_t count;
    memset(&d, 0, sizeof d);
    d.image = image;
    d.prompt = prompt && prompt->type == GSF_JSON_STRING ? prompt->string : NULL;
    if (!CHECK(inputs && usual)) return;
    if (d.prompt) {
        CHECK_OK(c->ctx, gsf_nn_encode_bpe(c->ctx, &net->tokenizer, d.prompt, strlen(d.prompt), 0, &ids, &count));
        check_blip2_ids("prompt", json, inputs, (size_t)net->query_tokens, ids, count);
        gsf_free(c->ctx, ids);
    }
    CHECK_OK(c->ctx, gsf__nn_caption_ids(c->ctx, net, &d, &ids, &count));
    check_blip2_ids("hf_generate_default", json, usual, inputs->count, ids, count);
    gsf_free(c->ctx, ids);
    d.max_new_tokens = 24;
    const gsf__nn_tap tap = {see_blip2_tap, c};
    d._tap = &tap;
    CHECK_OK(c->ctx, gsf__nn_caption_ids(c->ctx, net, &d, &ids, &count));
    check_blip2_ids("hf_generate_max_new_24", json, gsf_find_json_member(json, expected, "hf_generate_max_new_24"),
                    inputs->count, ids, count);
    gsf_free(c->ctx, ids);
    char caption[4096];
    const gsf_json_value* text = gsf_find_json_member(json, expected, "text");
    CHECK_OK(c->ctx, gsf_nn_caption_image(c->ctx, net, image, d.prompt, 24, caption, sizeof caption));
    if (CHECK(text && text->type == GSF_JSON_STRING)) check_blip2_text(text, caption);
}

// Repeats the run without image_token_index in config.json: the default length is then three tokens less.
static void check_blip2_legacy(const gsf_image* image, const gsf_json* json, const gsf_json_value* expected,
                               size_t queries) {
    blip2_folder folder;
    gsf_context ctx;
    gsf_nn_captioner net;
    gsf__nn_caption_desc d;
    int32_t* ids;
    size_t count;
    blip2_open(&folder, &ctx);
    char* config = blip2_edit("config.json", "\"image_token_index\"", "\"unused\"");
    blip2_put(&folder, "config.json", config, 0);
    if (!CHECK_OK(&ctx, gsf_nn_load_captioner(&ctx, blip2_golden(), &net))) return;
    CHECK(net.image_token == -1);
    memset(&d, 0, sizeof d);
    d.image = image;
    CHECK_OK(&ctx, gsf__nn_caption_ids(&ctx, &net, &d, &ids, &count));
    check_blip2_ids("legacy default", json, gsf_find_json_member(json, expected, "hf_generate_default"), 1, ids, count);
    gsf_free(&ctx, ids);
    d.max_new_tokens = 30 - 3; // max_length 30: the queries do not count, one bos twice and 1 off
    CHECK_OK(&ctx, gsf__nn_caption_ids(&ctx, &net, &d, &ids, &count));
    check_blip2_ids("legacy of 30", json, gsf_find_json_member(json, expected, "hf_generate_max_len_30"), 1, ids,
                    count);
    gsf_free(&ctx, ids);
    CHECK(count > 0 && net.query_tokens == (int32_t)queries);
    gsf_nn_destroy_captioner(&ctx, &net);
    free(config);
}

static void check_blip2_tokens(gsf_context* ctx, const gsf_nn_bpe* bpe, const gsf_json* json) {
    static const char* const lists[] = {"ids", "ids_no_special"};
    const gsf_json_value* cases = gsf_find_json_member(json, json->values, "tokenizer_cases");
    CHECK(cases && cases->count > 0);
    for (uint32_t i = cases->child; i; i = json->values[i].next) {
        const gsf_json_value* text = gsf_find_json_member(json, &json->values[i], "text");
        const gsf_json_value* decoded = gsf_find_json_member(json, &json->values[i], "decoded");
        for (int k = 0; k < 2; k++) {
            int32_t* ids;
            size_t count;
            gsf_buffer out;
            memset(&out, 0, sizeof out);
            CHECK_OK(ctx, gsf_nn_encode_bpe(ctx, bpe, text->string, text->string_size, k, &ids, &count));
            check_blip2_ids(text->string, json, gsf_find_json_member(json, &json->values[i], lists[k]), 0, ids, count);
            CHECK_OK(ctx, gsf_nn_decode_bpe(ctx, bpe, ids, count, 1, &out));
            CHECK(out.size == decoded->string_size && memcmp(out.data, decoded->string, out.size) == 0);
            gsf_destroy_buffer(ctx, &out);
            gsf_free(ctx, ids);
        }
    }
}

static void check_blip2(void) {
    static const char* const runs[] = {"no_prompt", "prompt"};
    gsf_context ctx;
    gsf_nn_captioner net;
    gsf_json json;
    blip2_case c;
    size_t size, index = 0;
    test_context_init(&ctx);
    if (!CHECK_OK(&ctx, gsf_nn_load_captioner(&ctx, blip2_golden(), &net))) return;
    char* text = test_read_file(test_golden("encoders/blip2/expected.json"), &size);
    if (!CHECK_OK(&ctx, gsf_parse_json(&ctx, "expected.json", text, size, &json))) return;
    check_blip2_tokens(&ctx, &net.tokenizer, &json);
    memset(&c, 0, sizeof c);
    c.ctx = &ctx;
    c.expected = test_open_tensors(test_golden("encoders/blip2/expected.safetensors"));
    const gsf_json_value* cases = gsf_find_json_member(&json, json.values, "cases");
    CHECK(cases && cases->count > 0);
    for (uint32_t i = cases->child; i; i = json.values[i].next, index++) {
        char path[256];
        gsf_image image;
        snprintf(path, sizeof path, "encoders/blip2/%s", gsf_find_json_member(&json, &json.values[i], "image")->string);
        if (!CHECK_OK(&ctx, gsf_load_image(&ctx, test_golden(path), 3, &image))) continue;
        snprintf(c.label, sizeof c.label, "case%zu", index);
        for (size_t k = 0; k < 2; k++) {
            const gsf_json_value* expected = gsf_find_json_member(&json, &json.values[i], runs[k]);
            c.run = runs[k];
            if (expected) check_blip2_run(&c, &net, &image, &json, expected);
        }
        const gsf_json_value* legacy = gsf_find_json_member(&json, &json.values[i], "legacy_no_image_token_index");
        if (legacy) check_blip2_legacy(&image, &json, legacy, (size_t)net.query_tokens);
        gsf_destroy_image(&ctx, &image);
    }
    CHECK(c.seen > 0);
    test_close_tensors(&c.expected);
    gsf_destroy_json(&ctx, &json);
    gsf_nn_destroy_captioner(&ctx, &net);
    free(text);
}

#endif
