// fuzz_json.c - the JSON parser, and what reads the config.json files of the networks. Build line: fuzz.h. What the parser
// accepts must print as text that parses to the same values again; a reader must answer with a result, one line of error
// and no memory left.
#include "gsfixer_nn.h"

#include "fuzz.h"

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
        FUZZ_CHECK(i > (uint32_t)(value - json->values) && i < json->count); // children follow their parent
        if (count) gsf_text_append(ctx, out, ",", 1);
        if (is_object) gsf_text_printf(ctx, out, "\"%u\":", (unsigned)count); // keys may hold zero bytes
        print_value(ctx, json, &json->values[i], out);
    }
    FUZZ_CHECK(count == value->count);
    gsf_text_append(ctx, out, is_object ? "}" : "]", 1);
}

static int same_value(const gsf_json_value* a, const gsf_json_value* b) {
    if (a->type != b->type || a->count != b->count || a->child != b->child || a->next != b->next) return 0;
    if (a->type == GSF_JSON_NUMBER) return memcmp(&a->number, &b->number, sizeof a->number) == 0;
    return a->type != GSF_JSON_STRING || strcmp(a->string, b->string) == 0;
}

// Members are found by their keys and elements by their places, and nothing else is.
static void check_access(const gsf_json* json, const gsf_json_value* value) {
    size_t place = 0;
    const int is_object = value->type == GSF_JSON_OBJECT, is_array = value->type == GSF_JSON_ARRAY;
    FUZZ_CHECK(value->type != GSF_JSON_STRING || value->string[value->string_size] == 0);
    FUZZ_CHECK(gsf_json_element(json, value, value->count) == NULL);
    FUZZ_CHECK(is_object || gsf_json_member(json, value, "") == NULL);
    for (uint32_t i = value->child; i && place < 40; i = json->values[i].next, place++) { // both walk the whole list
        const gsf_json_value* child = &json->values[i];
        FUZZ_CHECK(gsf_json_element(json, value, place) == (is_array ? child : NULL));
        FUZZ_CHECK((child->key != NULL) == is_object);
        if (is_object && strlen(child->key) == child->key_size)
            FUZZ_CHECK(gsf_json_member(json, value, child->key) == child);
    }
}

static void check_refused(const gsf_context* ctx, gsf_result result, const char* name) {
    FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED);
    FUZZ_CHECK(strncmp(ctx->error, name, strlen(name)) == 0);
    for (const char* c = ctx->error; *c; c++) FUZZ_CHECK((unsigned char)*c >= 0x20); // one line
}

static void check_parser(gsf_context* ctx, const char* data, size_t size) {
    gsf_json json, again;
    const gsf_result result = gsf_parse_json(ctx, "fuzz", data, size, &json);
    if (result == GSF_OK) {
        gsf_text text;
        memset(&text, 0, sizeof text);
        print_value(ctx, &json, json.values, &text);
        FUZZ_CHECK(!text.failed && gsf_parse_json(ctx, "again", text.data, text.size, &again) == GSF_OK);
        FUZZ_CHECK(again.count == json.count);
        for (size_t i = 0; i < json.count; i++) {
            FUZZ_CHECK(same_value(&json.values[i], &again.values[i]));
            check_access(&json, &json.values[i]);
        }
        gsf_destroy_json(ctx, &again);
        gsf_destroy_text(ctx, &text);
    } else {
        check_refused(ctx, result, "fuzz:");
        FUZZ_CHECK(result == GSF_ERROR_FORMAT && json.values == NULL && json.count == 0 && json.strings == NULL);
    }
    gsf_destroy_json(ctx, &json);
}

static void check_schedule(gsf_context* ctx, const char* data, size_t size) {
    gsf_nn_schedule schedule;
    const gsf_result result = gsf_nn_parse_schedule(ctx, "fuzz", data, size, &schedule);
    if (result == GSF_OK) {
        const gsf_nn_schedule_desc* d = &schedule.desc;
        int32_t steps[3], count;
        FUZZ_CHECK(d->train_steps >= 2 && isfinite(schedule.final_alpha_bar));
        FUZZ_CHECK(isfinite(schedule.alpha_bar[0]) && isfinite(schedule.alpha_bar[d->train_steps - 1]));
        if (d->train_steps >= 3 && gsf_nn_make_timesteps(ctx, &schedule, 3, 0.0, steps, &count) == GSF_OK)
            for (int32_t i = 0; i < count; i++) FUZZ_CHECK(steps[i] >= 0 && steps[i] < d->train_steps);
        gsf_nn_destroy_schedule(ctx, &schedule);
    } else {
        FUZZ_CHECK(schedule.alpha_bar == NULL && ctx->error[0] != 0);
    }
}

typedef struct fuzz_folder { const void* config; size_t size; } fuzz_folder;

// A model's folder: the input as config.json, and weights without a tensor.
static gsf_result read_fn(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    const fuzz_folder* folder = (const fuzz_folder*)user;
    static const char weights[] = "\2\0\0\0\0\0\0\0{}";
    const int is_config = strcmp(path, "fuzz/config.json") == 0;
    if (strstr(path, ".index.json")) return gsf_fail(ctx, GSF_ERROR_IO, "%s: not there", path);
    *size = is_config ? folder->size : sizeof weights - 1;
    *data = gsf_alloc(ctx, *size, 1);
    FUZZ_CHECK(*data);
    if (*size) memcpy(*data, is_config ? folder->config : weights, *size);
    return GSF_OK;
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    fuzz_folder folder;
    gsf_nn_transformer transformer;
    gsf_nn_vae vae;
    if (!data) data = (const uint8_t*)"";
    fuzz_limit = 192 * size + ((size_t)1 << 20); // the values, the text that they print as, and its values
    check_parser(&ctx, (const char*)data, size);
    folder.config = data;
    folder.size = size;
    ctx.io.read_fn = read_fn;
    ctx.io.user = &folder;
    check_refused(&ctx, gsf_nn_make_transformer(&ctx, "fuzz", &transformer), "fuzz");
    check_refused(&ctx, gsf_nn_make_vae(&ctx, "fuzz", &vae), "fuzz");
    fuzz_limit += (size_t)16 << 20; // a table of up to a million steps
    check_schedule(&ctx, (const char*)data, size);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
