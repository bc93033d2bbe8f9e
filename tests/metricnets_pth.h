// metricnets_pth.h - PyTorch files: those of pth/list.json hold the tensors of their safetensors twins, bit for bit; those
// of bad/list.json are refused with one line, without memory out of proportion.
#ifndef METRICNETS_PTH_H
#define METRICNETS_PTH_H

#include "test.h"
#include "test_hooks.h"

static inline const char* pth_path(const char* folder, const char* name) { // static buffer
    static char path[2048];
    char inner[512];
    snprintf(inner, sizeof inner, "metricnets/%s/%s", folder, name);
    snprintf(path, sizeof path, "%s", test_golden(inner));
    return path;
}

static inline const char* pth_text(const gsf_json* json, const gsf_json_value* entry, const char* key) {
    const gsf_json_value* value = gsf_find_json_member(json, entry, key);
    return CHECK(value && value->type == GSF_JSON_STRING) ? value->string : "";
}

static inline void check_pth_good(gsf_context* ctx, const char* file, const char* expected) {
    gsf_nn_weights got, want;
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, pth_path("pth", file), NULL, &got))) return;
    if (CHECK_OK(ctx, gsf_nn_load_weights(ctx, pth_path("pth", expected), NULL, &want))) {
        CHECK(want.tensor_count > 0 && got.tensor_count == want.tensor_count);
        for (size_t i = 0; i < want.tensor_count; i++) {
            const gsf_nn_tensor *w = &want.tensors[i], *g = gsf_nn_find_tensor(&got, w->name);
            if (!CHECK(g != NULL)) {
                fprintf(stderr, "    %s: no tensor %s\n", file, w->name);
                continue;
            }
            const int same = g->dtype == w->dtype && g->rank == w->rank && g->count == w->count &&
                             memcmp(g->shape, w->shape, sizeof g->shape) == 0;
            if (!CHECK(same && memcmp(g->data, w->data, (size_t)w->count * gsf_nn_get_dtype_size(w->dtype)) == 0))
                fprintf(stderr, "    %s: tensor %s differs\n", file, w->name);
        }
        gsf_nn_destroy_weights(ctx, &want);
    }
    gsf_nn_destroy_weights(ctx, &got);
}

static inline void check_pth_bad(const char* file, int must_refuse) {
    gsf_context ctx;
    gsf_nn_weights w;
    counter c;
    size_t size;
    memset(&c, 0, sizeof c);
    test_context_zero(&ctx);
    count_memory(&ctx, &c);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    char* data = test_read_file(pth_path("bad", file), &size);
    char* exact = (char*)malloc(size ? size : 1); // so that AddressSanitizer sees a read beyond its end
    memcpy(exact, data, size);
    const gsf_result result = gsf_nn_parse_weights(&ctx, file, exact, size, &w);
    if (result || must_refuse) {
        CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED);
        CHECK(strncmp(ctx.error, file, strlen(file)) == 0 && ctx.error[strlen(file)] == ':');
        for (const char* p = ctx.error; *p; p++) CHECK((unsigned char)*p >= 0x20 && (unsigned char)*p < 0x7f);
        if (getenv("GSF_TEST_VERBOSE")) printf("%s\n", ctx.error);
    }
    if (!result) gsf_nn_destroy_weights(&ctx, &w);
    CHECK(c.live == 0 && c.asked < 256 * size + ((size_t)1 << 20));
    free(exact);
    free(data);
}

static inline void check_pth(void) {
    gsf_context ctx;
    gsf_json json;
    size_t size;
    test_context_init(&ctx);
    for (int bad = 0; bad < 2; bad++) {
        char* text = test_read_file(pth_path(bad ? "bad" : "pth", "list.json"), &size);
        if (CHECK_OK(&ctx, gsf_parse_json(&ctx, "list.json", text, size, &json))) {
            CHECK(json.values[0].count > 0);
            for (uint32_t i = json.values[0].child; i; i = json.values[i].next) {
                const gsf_json_value* e = &json.values[i];
                const char* file = pth_text(&json, e, "file");
                if (bad) check_pth_bad(file, strcmp(pth_text(&json, e, "expect"), "reject") == 0);
                else check_pth_good(&ctx, file, pth_text(&json, e, "expected"));
            }
            gsf_destroy_json(&ctx, &json);
        }
        free(text);
    }
}

#endif
