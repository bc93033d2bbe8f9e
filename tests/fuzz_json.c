// fuzz_json.c - the JSON parser. Build line: fuzz.h. Accepted documents print as text that parses to the same values;
// refused ones give a one-line error and leave no memory allocated.
#include "fuzz.h"

static void print_value(gsf_context* ctx, const gsf_json* json, const gsf_json_value* value, gsf_buffer* out) {
    static const char* const words[] = {"null", "false", "true"};
    if (value->type <= GSF_JSON_TRUE) gsf_append_text(ctx, out, "%s", words[value->type]);
    if (value->type == GSF_JSON_NUMBER) gsf_append_json_number(ctx, out, value->number);
    if (value->type == GSF_JSON_STRING) gsf_append_json_string(ctx, out, value->string); // up to a zero byte
    if (value->type < GSF_JSON_ARRAY) return;
    const int is_object = value->type == GSF_JSON_OBJECT;
    uint32_t count = 0;
    gsf_append_bytes(ctx, out, is_object ? "{" : "[", 1);
    for (uint32_t i = value->child; i; i = json->values[i].next, count++) {
        FUZZ_CHECK(i > (uint32_t)(value - json->values) && i < json->count); // children follow their parent
        if (count) gsf_append_bytes(ctx, out, ",", 1);
        if (is_object) gsf_append_text(ctx, out, "\"%u\":", (unsigned)count); // keys may hold zero bytes
        print_value(ctx, json, &json->values[i], out);
    }
    FUZZ_CHECK(count == value->count);
    gsf_append_bytes(ctx, out, is_object ? "}" : "]", 1);
}

static int same_value(const gsf_json_value* a, const gsf_json_value* b) {
    if (a->type != b->type || a->count != b->count || a->child != b->child || a->next != b->next) return 0;
    if (a->type == GSF_JSON_NUMBER) return memcmp(&a->number, &b->number, sizeof a->number) == 0;
    return a->type != GSF_JSON_STRING || strcmp(a->string, b->string) == 0;
}

// Members are found by their keys and elements by their indices; absent ones are not found.
static void check_access(const gsf_json* json, const gsf_json_value* value) {
    size_t place = 0;
    const int is_object = value->type == GSF_JSON_OBJECT, is_array = value->type == GSF_JSON_ARRAY;
    FUZZ_CHECK(value->type != GSF_JSON_STRING || value->string[value->string_size] == 0);
    FUZZ_CHECK(gsf_find_json_element(json, value, value->count) == NULL);
    FUZZ_CHECK(is_object || gsf_find_json_member(json, value, "") == NULL);
    // only the first 40, as both lookups walk the list
    for (uint32_t i = value->child; i && place < 40; i = json->values[i].next, place++) {
        const gsf_json_value* child = &json->values[i];
        FUZZ_CHECK(gsf_find_json_element(json, value, place) == (is_array ? child : NULL));
        FUZZ_CHECK((child->key != NULL) == is_object);
        if (is_object && strlen(child->key) == child->key_size)
            FUZZ_CHECK(gsf_find_json_member(json, value, child->key) == child);
    }
}

static void check_parser(gsf_context* ctx, const char* data, size_t size) {
    gsf_json json, again;
    const gsf_result result = gsf_parse_json(ctx, "fuzz", data, size, &json);
    if (result == GSF_OK) {
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        print_value(ctx, &json, json.values, &text);
        FUZZ_CHECK(!text.failed && gsf_parse_json(ctx, "again", text.data, text.size, &again) == GSF_OK);
        FUZZ_CHECK(again.count == json.count);
        for (size_t i = 0; i < json.count; i++) {
            FUZZ_CHECK(same_value(&json.values[i], &again.values[i]));
            check_access(&json, &json.values[i]);
        }
        gsf_destroy_json(ctx, &again);
        gsf_destroy_buffer(ctx, &text);
    } else {
        fuzz_check_error(ctx, "fuzz:");
        FUZZ_CHECK(result == GSF_ERROR_FORMAT && json.values == NULL && json.count == 0 && json.strings == NULL);
    }
    gsf_destroy_json(ctx, &json);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    if (!data) data = (const uint8_t*)"";
    fuzz_limit = 192 * size + ((size_t)1 << 20); // the values, their text, and the values parsed from it
    check_parser(&ctx, (const char*)data, size);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
