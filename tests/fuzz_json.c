// Fuzz target for the JSON parser. What it accepts must print as text that parses to the same values again.
//   clang -g -O1 -fsanitize=fuzzer,address,undefined -I. tests/fuzz_json.c -o fuzz_json -lm
//   ./fuzz_json tests/corpus/json
#define GSFIXER_IMPLEMENTATION
#include "gsfixer.h"

static void print_value(gsf_context* ctx, const gsf_json* json, const gsf_json_value* value, gsf_text* out) {
    static const char* const words[] = {"null", "false", "true"};
    if (value->type <= GSF_JSON_TRUE) gsf_text_printf(ctx, out, "%s", words[value->type]);
    if (value->type == GSF_JSON_NUMBER) gsf_text_json_number(ctx, out, value->number);
    if (value->type == GSF_JSON_STRING) gsf_text_json_string(ctx, out, value->string); // up to a zero byte
    if (value->type < GSF_JSON_ARRAY) return;
    const int is_object = value->type == GSF_JSON_OBJECT;
    uint32_t count = 0;
    gsf_text_append(ctx, out, is_object ? "{" : "[", 1);
    for (uint32_t i = value->child; i; i = json->values[i].next, count++) {
        if (i <= (uint32_t)(value - json->values) || i >= json->count) abort(); // children follow their parent
        if (count) gsf_text_append(ctx, out, ",", 1);
        if (is_object) gsf_text_printf(ctx, out, "\"%u\":", (unsigned)count); // keys may hold zero bytes
        print_value(ctx, json, &json->values[i], out);
    }
    if (count != value->count) abort();
    gsf_text_append(ctx, out, is_object ? "}" : "]", 1);
}

static int same_value(const gsf_json_value* a, const gsf_json_value* b) {
    if (a->type != b->type || a->count != b->count || a->child != b->child || a->next != b->next) return 0;
    if (a->type == GSF_JSON_NUMBER) return memcmp(&a->number, &b->number, sizeof a->number) == 0;
    return a->type != GSF_JSON_STRING || strcmp(a->string, b->string) == 0;
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK) abort();
    gsf_json json, again;
    const gsf_result result = gsf_parse_json(&ctx, "fuzz", (const char*)data, size, &json);
    if (result == GSF_OK) {
        gsf_text text;
        memset(&text, 0, sizeof text);
        print_value(&ctx, &json, json.values, &text);
        if (text.failed || gsf_parse_json(&ctx, "again", text.data, text.size, &again) != GSF_OK) abort();
        if (again.count != json.count) abort();
        for (size_t i = 0; i < json.count; i++)
            if (!same_value(&json.values[i], &again.values[i])) abort();
        gsf_destroy_json(&ctx, &again);
        gsf_destroy_text(&ctx, &text);
    } else if (result != GSF_ERROR_FORMAT || strncmp(ctx.error, "fuzz:", 5) != 0) {
        abort();
    }
    gsf_destroy_json(&ctx, &json);
    return 0;
}
