// Edge cases of gsfixer.h: hooks, failing memory and disks, damaged files, JSON, images, random numbers, cameras.
#ifdef __linux__
#define _POSIX_C_SOURCE 200809L
#include <sys/stat.h>
#include <unistd.h>
#endif
#include <locale.h>

#define GSFIXER_IMPLEMENTATION
#include "gsfixer.h"
#include "test.h"

// ---- a counting allocator that fails on the k-th call --------------------------

typedef struct heap {
    size_t calls, fail_at; // fail_at: 1-based, 0 = never
    int64_t live;
} heap;

static void* heap_alloc(void* user, size_t size) {
    heap* h = (heap*)user;
    if (++h->calls == h->fail_at) return NULL;
    size_t* block = (size_t*)malloc(size + 16);
    if (!block) return NULL;
    block[0] = size;
    h->live += (int64_t)size;
    return (char*)block + 16;
}

static void heap_free(void* user, void* memory) {
    size_t* block = (size_t*)(void*)((char*)memory - 16);
    ((heap*)user)->live -= (int64_t)block[0];
    free(block);
}

static void init_with_heap(gsf_context* ctx, heap* h) {
    memset(h, 0, sizeof *h);
    test_context_zero(ctx);
    ctx->allocator.alloc_fn = heap_alloc;
    ctx->allocator.free_fn = heap_free;
    ctx->allocator.user = h;
    CHECK_OK(ctx, gsf_init_context(ctx));
}

// ---- context -------------------------------------------------------------------

static gsf_result no_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user;
    (void)data;
    return gsf_fail(ctx, GSF_ERROR_IO, "%s: %zu bytes refused", path, size);
}

static void forget_for(void* user, size_t count, gsf_chunk_fn body, void* arg) {
    (void)user;
    for (size_t i = 0; i < count; i++) body(arg, i, 0);
}

static void log_line(void* user, gsf_log_level level, const char* text) {
    if (level == GSF_LOG_ERROR) snprintf((char*)user, 64, "%.63s", text);
}

// AUTO selects the machine's highest level, except for bfloat16 dot products that are slower than float32; Intel's are, without
// tiles.
static void test_auto_level(gsf_cpu_level selected) {
    gsf_context ctx;
    char line[4096];
    int intel = 0, bf16 = 0, tiles = 0;
    FILE* file = fopen("/proc/cpuinfo", "r");
    while (file && fgets(line, sizeof line, file)) {
        intel |= strstr(line, "GenuineIntel") != NULL;
        bf16 |= strstr(line, " avx512_bf16") != NULL;
        tiles |= strstr(line, " amx_bf16") != NULL;
    }
    if (file) fclose(file);
    memset(&ctx, 0, sizeof ctx);
    ctx.cpu_level = GSF_CPU_AMX;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    if (ctx.cpu_level == GSF_CPU_AMX) CHECK(selected == ctx.cpu_level && tiles);
    else if (ctx.cpu_level != GSF_CPU_AVX512_BF16) CHECK(selected == ctx.cpu_level || selected == GSF_CPU_SIMD128);
    else if (bf16) CHECK(selected == (intel ? GSF_CPU_AVX512_VNNI : GSF_CPU_AVX512_BF16));
}

static void test_hooks(void) {
    gsf_context ctx;
    test_context_zero(&ctx);
    ctx.allocator.alloc_fn = heap_alloc; // only one of the two functions
    CHECK_RESULT(&ctx, gsf_init_context(&ctx), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx.error, "allocator") != NULL);
    test_context_zero(&ctx);
    ctx.io.write_fn = no_write;
    CHECK_RESULT(&ctx, gsf_init_context(&ctx), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx.error, "io") != NULL);
    test_context_zero(&ctx);
    ctx.parallel.for_fn = forget_for;
    CHECK_RESULT(&ctx, gsf_init_context(&ctx), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx.error, "worker_count") != NULL);

    memset(&ctx, 0, sizeof ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    CHECK(ctx.allocator.alloc_fn && ctx.io.read_fn && ctx.io.write_fn && ctx.parallel.for_fn && ctx.initialized);
    CHECK(ctx.parallel.worker_count >= 1 && ctx.cpu_level >= GSF_CPU_SCALAR);
    test_auto_level(ctx.cpu_level);
    memset(&ctx, 0, sizeof ctx);
    ctx.cpu_level = GSF_CPU_SCALAR;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    CHECK(ctx.cpu_level == GSF_CPU_SCALAR);

    char logged[64] = "";
    ctx.logger.log_fn = log_line;
    ctx.logger.user = logged;
    CHECK(gsf_fail(&ctx, GSF_ERROR_FORMAT, "x %d", 5) == GSF_ERROR_FORMAT);
    CHECK(strcmp(ctx.error, "x 5") == 0 && strcmp(logged, "x 5") == 0);
    CHECK(gsf_fail(&ctx, GSF_ERROR_IO, "again: %s", ctx.error) == GSF_ERROR_IO); // an argument may be ctx->error
    CHECK(strcmp(ctx.error, "again: x 5") == 0);
    char huge[2000];
    memset(huge, 'a', sizeof huge - 1);
    huge[sizeof huge - 1] = 0;
    CHECK(gsf_fail(&ctx, GSF_ERROR_IO, "%s", huge) == GSF_ERROR_IO && strlen(ctx.error) == sizeof ctx.error - 1);
    CHECK(!gsf_is_cancelled(&ctx));
    gsf_request_cancel(&ctx);
    CHECK(gsf_is_cancelled(&ctx));
    gsf_clear_cancel(&ctx);
    CHECK(!gsf_is_cancelled(&ctx));
    for (int r = 0; r <= GSF_ERROR_RESTORER + 1; r++) CHECK(strlen(gsf_describe_result((gsf_result)r)) > 0);

    // a context whose struct was moved keeps working, with its workers if it had any
    gsf_context moved = ctx;
    memset(&ctx, 0xff, sizeof ctx);
    gsf_image a, b;
    CHECK_OK(&moved, gsf_make_image(&moved, GSF_U8, 300, 300, 3, &a));
    CHECK_OK(&moved, gsf_make_image(&moved, GSF_F32, 300, 300, 3, &b));
    CHECK_OK(&moved, gsf_convert_image(&moved, &a, &b));
    gsf_destroy_image(&moved, &a);
    gsf_destroy_image(&moved, &b);
}

// ---- failing memory ------------------------------------------------------------

// Calls every function of the header that allocates. Returns the first result that is not GSF_OK.
static gsf_result use_everything(gsf_context* ctx, const char* png, const char* jpg, const char* cameras) {
    gsf_image image, small, packed;
    gsf_json json;
    gsf_buffer text;
    gsf_camera* list = NULL;
    size_t count = 0;
    double value = 0.0;
    static const char object[] =
        "{\"a\":1,\"b\":2,\"c\":3,\"d\":4,\"e\":5,\"f\":6,\"g\":7,\"h\":8,\"i\":9,\"j\":10,\"k\":11,\"l\":12,"
        "\"m\":13,\"n\":14,\"o\":15,\"p\":16,\"q\":[\"\\u00e9\",true,null]}";
    memset(&image, 0, sizeof image);
    memset(&small, 0, sizeof small);
    memset(&packed, 0, sizeof packed);
    memset(&json, 0, sizeof json);
    memset(&text, 0, sizeof text);
    gsf_result result = gsf_load_image(ctx, jpg, 3, &image);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, 20, 10, 3, &small);
    if (result == GSF_OK) result = gsf_resize_image(ctx, &image, GSF_RESIZE_PIL_LANCZOS, &small);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, 20, 10, 3, &packed);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &small, &packed);
    for (int kind = GSF_METRIC_PSNR; kind <= GSF_METRIC_SSIM_SKIMAGE && result == GSF_OK; kind++)
        result = gsf_measure_image(ctx, (gsf_metric)kind, &small, &packed, NULL, &value);
    if (result == GSF_OK) result = gsf_save_image(ctx, png, &packed);
    if (result == GSF_OK) result = gsf_encode_image(ctx, &small, ".jpg", &text);
    if (result == GSF_OK) result = gsf_parse_json(ctx, "object", object, sizeof object - 1, &json);
    if (result == GSF_OK) result = gsf_load_cameras(ctx, cameras, &list, &count);
    if (result == GSF_OK) result = gsf_save_cameras(ctx, cameras, list, NULL, count);
    gsf_destroy_image(ctx, &image);
    gsf_destroy_image(ctx, &small);
    gsf_destroy_image(ctx, &packed);
    gsf_destroy_json(ctx, &json);
    gsf_destroy_buffer(ctx, &text);
    gsf_free(ctx, list);
    return result;
}

static gsf_camera plain_camera(void) {
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.w2c[0] = camera.w2c[5] = camera.w2c[10] = camera.w2c[15] = 1.0;
    camera.fx = 500.0;
    camera.fy = 510.0;
    camera.cx = 320.0;
    camera.cy = 240.0;
    camera.width = 640;
    camera.height = 480;
    return camera;
}

static void test_base_out_of_memory(void) {
    gsf_context ctx;
    heap h;
    init_with_heap(&ctx, &h);
    char png[1024], jpg[1024], cameras[1024];
    snprintf(png, sizeof png, "%s", test_scratch("oom.png"));
    snprintf(jpg, sizeof jpg, "%s", test_scratch("oom.jpg"));
    snprintf(cameras, sizeof cameras, "%s", test_scratch("oom.json"));
    const gsf_camera camera = plain_camera();
    const char* name = "x";
    gsf_image image;
    CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_U8, 61, 40, 3, &image));
    for (int i = 0; i < 61 * 40 * 3; i++) ((uint8_t*)image.data)[i] = (uint8_t)(i * 7);
    CHECK_OK(&ctx, gsf_save_image(&ctx, jpg, &image));
    CHECK_OK(&ctx, gsf_save_cameras(&ctx, cameras, &camera, &name, 1));
    gsf_destroy_image(&ctx, &image);
    h.calls = 0;
    CHECK_OK(&ctx, use_everything(&ctx, png, jpg, cameras));
    CHECK(h.live == 0);
    const size_t calls = h.calls;
    CHECK(calls > 20);
    for (size_t k = 1; k <= calls; k++) {
        h.calls = 0;
        h.fail_at = k;
        ctx.error[0] = 0;
        CHECK_RESULT(&ctx, use_everything(&ctx, png, jpg, cameras), GSF_ERROR_OUT_OF_MEMORY);
        CHECK(strstr(ctx.error, "memory") != NULL);
        if (!CHECK(h.live == 0)) fprintf(stderr, "allocation %zu: %lld bytes live\n", k, (long long)h.live);
    }
    h.fail_at = 0;
    CHECK_OK(&ctx, use_everything(&ctx, png, jpg, cameras)); // the failures left the files intact
    CHECK(h.live == 0);
}

// ---- chunks --------------------------------------------------------------------

static void test_damaged_chunks(gsf_context* ctx) {
    gsf_buffer file;
    memset(&file, 0, sizeof file);
    static char payload[40000]; // long enough for the fast CRC code path
    for (size_t i = 0; i < sizeof payload; i++) payload[i] = (char)(i * 31 >> 3);
    gsf_append_chunk(ctx, &file, "ABCD", "hello", 5);
    gsf_append_chunk(ctx, &file, "NONE", NULL, 0);
    const size_t small_end = file.size;
    gsf_append_chunk(ctx, &file, "LONG", payload, sizeof payload);
    const size_t long_end = file.size;
    uint32_t crc = 0xffffffffu, stored = 0; // bitwise CRC-32 of tag, size and payload
    for (size_t i = small_end; i < long_end - 4; i++) {
        crc ^= (unsigned char)file.data[i];
        for (int bit = 0; bit < 8; bit++) crc = crc & 1u ? 0xedb88320u ^ crc >> 1 : crc >> 1;
    }
    for (size_t i = 0; i < 4; i++) stored |= (uint32_t)(unsigned char)file.data[long_end - 4 + i] << 8 * i;
    CHECK(stored == ~crc);
    const size_t opened = gsf__open_chunk(ctx, &file, "LONG"); // the same chunk, appended in pieces
    for (size_t i = 0; i < sizeof payload; i += 999)
        gsf_append_bytes(ctx, &file, payload + i, sizeof payload - i < 999 ? sizeof payload - i : 999);
    gsf__close_chunk(ctx, &file, opened);
    CHECK(opened == long_end && file.size - opened == long_end - small_end);
    CHECK(memcmp(file.data + small_end, file.data + opened, long_end - small_end) == 0);
    file.size = long_end;
    gsf_append_last_chunk(ctx, &file);
    CHECK(!file.failed);
    CHECK_OK(ctx, gsf_check_chunks(ctx, "file", file.data, file.size));
    gsf_chunk chunk;
    CHECK(gsf_find_chunk(file.data, file.size, "LONG", &chunk) && chunk.size == sizeof payload);
    CHECK(memcmp(chunk.data, payload, sizeof payload) == 0);
    CHECK(gsf_find_chunk(file.data, file.size, "NONE", &chunk) && chunk.size == 0);
    CHECK(!gsf_find_chunk(file.data, file.size, "WXYZ", &chunk));

    for (size_t n = 0; n < file.size; n += n < small_end + 40 || n + 40 > file.size ? 1 : 991) { // truncations
        char* copy = (char*)malloc(n ? n : 1);
        memcpy(copy, file.data, n);
        CHECK_RESULT(ctx, gsf_check_chunks(ctx, "cut", copy, n), GSF_ERROR_FORMAT);
        free(copy);
    }
    for (size_t i = 0; i < file.size; i += i < small_end + 40 || i + 40 > file.size ? 1 : 499) // every byte flipped
        for (int bit = 0; bit < 8; bit++) {
            file.data[i] = (char)(file.data[i] ^ 1 << bit);
            CHECK(gsf_check_chunks(ctx, "flipped", file.data, file.size) != GSF_OK);
            file.data[i] = (char)(file.data[i] ^ 1 << bit);
        }
    gsf_append_bytes(ctx, &file, "x", 1); // trailing data
    CHECK_RESULT(ctx, gsf_check_chunks(ctx, "longer", file.data, file.size), GSF_ERROR_FORMAT);
    gsf_destroy_buffer(ctx, &file);
}

// ---- JSON ----------------------------------------------------------------------

static gsf_result parse(gsf_context* ctx, const char* text, size_t size) { // in a block of exactly that size, for ASan
    char* copy = (char*)malloc(size ? size : 1);
    memcpy(copy, text, size);
    gsf_json json;
    const gsf_result result = gsf_parse_json(ctx, "text", copy, size, &json);
    free(copy);
    if (result != GSF_OK) CHECK(json.values == NULL && json.strings == NULL && json.count == 0);
    gsf_destroy_json(ctx, &json);
    return result;
}

static void test_json_conformance(gsf_context* ctx) {
    static const char* const good[] = {
        "null", "true", "false", "0", "-0", "-0.0e-0", "1E5", "1e+05", "12.5e-3", "\"\"", "[]", "{}", " [ ] ",
        "\t\r\n{ }\n", "[1,2,[3,{}],{\"a\":[]}]", "{\"\":0}", "{\"a\":{\"a\":1},\"b\":{\"a\":2}}", "\"\\u0000\"",
        "\"\\ud83d\\ude00\"", "\"\\\"\\\\\\/\\b\\f\\n\\r\\t\"", "\"\xc3\xa9\xe2\x82\xac\xf0\x9f\x98\x80\"", "\"\x7f\"",
        "\"\xf4\x8f\xbf\xbf\"", "\"\xed\x9f\xbf\xee\x80\x80\"", "1e-400",
        "0.00000000000000000000000000000000000000000000001", "1.7976931348623157e308", "123456789012345678901234567890",
        "[0.1,-1.5E+10]", "{\"a\\u0000\":1,\"a\":2}"};
    static const char* const bad[] = {
        "", " ", "nul", "nulll", "True", "NaN", "Infinity", "-Infinity", "-", "+1", "01", "-01", "1.", ".5", "1.e5",
        "1e", "1e+", "0x10", "1 2", "[1,]", "[,1]", "[1,,2]", "[", "]", "[1", "[1 2]", "{", "}", "{\"a\"}", "{\"a\":}",
        "{\"a\":1,}", "{a:1}", "{'a':1}", "{\"a\":1 \"b\":2}", "{1:2}", "{\"a\" 1}", "[\"a\":1]", "\"", "\"a", "'a'",
        "\"\\\"", "\"\\x41\"", "\"\\u12g4\"", "\"\\u123\"", "\"\\ud800\"", "\"\\udc00\"", "\"\\ud800\\u0041\"",
        "\"\\ud800\\ud800\"", "\"\\ud800x\"", "\"\n\"", "\"\t\"", "\"\x01\"", "\"\xff\"", "\"\xc0\xaf\"", "\"\xc3\"",
        "\"\xe2\x82\"", "\"\xed\xa0\x80\"", "\"\xf5\x80\x80\x80\"", "\"\xf4\x90\x80\x80\"", "\"\xf0\x80\x80\x80\"",
        "\"\x80\"", "1e999", "-1e999", "[1e400]", "{\"a\":1,\"a\":2}", "{\"a\":1,\"\\u0061\":2}",
        "{\"x\":[{\"a\":1,\"b\":1,\"a\":1}]}", "\xef\xbb\xbf[]", "// c\n1", "/**/1", "[1]x", "[1]]", "{}{}", "\f1",
        "\v1", "1\xa0", "[\"a\",\n4\n,1,", "{\"a\":/*c*/1}", "\xff\xfe[\0]\0"};
    for (size_t i = 0; i < sizeof good / sizeof *good; i++)
        if (parse(ctx, good[i], strlen(good[i])) != GSF_OK) CHECK_OK(ctx, parse(ctx, good[i], strlen(good[i])));
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        ctx->error[0] = 0;
        if (parse(ctx, bad[i], strlen(bad[i])) != GSF_ERROR_FORMAT) {
            fprintf(stderr, "accepted: %s\n", bad[i]);
            CHECK(0);
        }
        CHECK(strncmp(ctx->error, "text:", 5) == 0 && strchr(ctx->error, '\n') == NULL);
    }
    CHECK_RESULT(ctx, parse(ctx, "[1,\0]", 5), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, parse(ctx, "\"\0\"", 3), GSF_ERROR_FORMAT);
    // the offset points at the offending byte
    CHECK_RESULT(ctx, parse(ctx, "{\"abc\": tru}", 12), GSF_ERROR_FORMAT);
    CHECK(strncmp(ctx->error, "text:8:", 7) == 0);
    gsf_json json; // longer than 32-bit offsets can address: refused before a byte is read
    CHECK_RESULT(ctx, gsf_parse_json(ctx, "text", "1", (size_t)0xfffffff1u, &json), GSF_ERROR_UNSUPPORTED);
    CHECK(json.values == NULL && strncmp(ctx->error, "text: JSON of", 13) == 0);
    // every proper prefix of a document is refused
    static const char whole[] = "{\"name\":\"\\u00e9\xc3\xa9\",\"list\":[1,-2.5e3,true,null,{\"k\":\"v\"}]}";
    CHECK_OK(ctx, parse(ctx, whole, sizeof whole - 1));
    for (size_t n = 0; n < sizeof whole - 1; n++) CHECK_RESULT(ctx, parse(ctx, whole, n), GSF_ERROR_FORMAT);
    // depth
    char deep[200];
    for (int depth = 60; depth <= 70; depth++) {
        memset(deep, '[', (size_t)depth);
        memset(deep + depth, ']', (size_t)depth);
        CHECK_RESULT(ctx, parse(ctx, deep, 2 * (size_t)depth), depth <= 64 ? GSF_OK : GSF_ERROR_FORMAT);
    }
}

static void test_json_values(gsf_context* ctx) {
    static const char text[] = " {\"a\":[10,\"\\ud83d\\ude00\\u0000z\",{\"deep\":false}],\"b\":null,\"c\\n\":-1.25e2} ";
    gsf_json json;
    if (!CHECK_OK(ctx, gsf_parse_json(ctx, "values", text, sizeof text - 1, &json))) return;
    const gsf_json_value *root = json.values, *a = gsf_find_json_member(&json, root, "a");
    CHECK(json.count == 8 && root->type == GSF_JSON_OBJECT && root->count == 3 && root->offset == 1);
    CHECK(a && a->type == GSF_JSON_ARRAY && a->count == 3 && a->child > (uint32_t)(a - json.values));
    CHECK(gsf_find_json_element(&json, a, 0)->number == 10.0);
    const gsf_json_value* s = gsf_find_json_element(&json, a, 1);
    CHECK(s->type == GSF_JSON_STRING && s->string_size == 6 && memcmp(s->string, "\xf0\x9f\x98\x80\0z", 7) == 0);
    CHECK(gsf_find_json_member(&json, gsf_find_json_element(&json, a, 2), "deep")->type == GSF_JSON_FALSE);
    CHECK(gsf_find_json_element(&json, a, 3) == NULL && gsf_find_json_element(&json, root, 0) == NULL);
    CHECK(gsf_find_json_member(&json, root, "b")->type == GSF_JSON_NULL);
    CHECK(gsf_find_json_member(&json, root, "c\n")->number == -125.0 && gsf_find_json_member(&json, root,
                                                                                             "c\n")->next == 0);
    CHECK(gsf_find_json_member(&json, root, "d") == NULL && gsf_find_json_member(&json, NULL, "a") == NULL);
    CHECK(gsf_find_json_member(&json, a, "a") == NULL);
    gsf_destroy_json(ctx, &json);

    enum { MEMBERS = 50000 }; // many members, then a duplicate key
    gsf_buffer big;
    memset(&big, 0, sizeof big);
    for (int twice = 0; twice < 2; twice++) {
        big.size = 0;
        gsf_append_bytes(ctx, &big, "{", 1);
        for (int i = 0; i < MEMBERS; i++)
            gsf_append_text(ctx, &big, "%s\"k%d\":%d", i ? "," : "", i * 7919 % MEMBERS, i);
        gsf_append_text(ctx, &big, "%s}", twice ? ",\"k1234\":0" : "");
        CHECK_RESULT(ctx, parse(ctx, big.data, big.size), twice ? GSF_ERROR_FORMAT : GSF_OK);
    }
    CHECK(strstr(ctx->error, "k1234") != NULL);
    gsf_destroy_buffer(ctx, &big);
}

static double number_of(gsf_context* ctx, const char* text) {
    gsf_json json;
    double value = NAN;
    if (CHECK_OK(ctx, gsf_parse_json(ctx, "number", text, strlen(text), &json))) value = json.values[0].number;
    gsf_destroy_json(ctx, &json);
    return value;
}

static void check_number_round_trip(gsf_context* ctx, double value) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_append_json_number(ctx, &text, value);
    const double back = number_of(ctx, text.data);
    CHECK(memcmp(&back, &value, sizeof value) == 0);
    gsf_destroy_buffer(ctx, &text);
}

static void test_json_numbers(gsf_context* ctx) {
    // a digit far behind the point decides the rounding: exactly, just below and just above the midpoint of two doubles
    CHECK(number_of(ctx, "9007199254740993") == 9007199254740992.0);
    CHECK(number_of(ctx, "9007199254740993.00000000000000000000000000000000000000001") == 9007199254740994.0);
    CHECK(number_of(ctx, "1.00000000000000011102230246251565404236316680908203125") == 1.0);
    CHECK(number_of(ctx, "1.00000000000000011102230246251565404236316680908203124") == 1.0);
    CHECK(number_of(ctx, "1.00000000000000011102230246251565404236316680908203126") == 1.0 + 2.220446049250313e-16);
    CHECK(number_of(ctx, "2.2250738585072011e-308") == 2.2250738585072011e-308);
    CHECK(number_of(ctx, "4.9406564584124654e-324") == 4.9406564584124654e-324);
    CHECK(number_of(ctx, "2e-324") == 0.0 && signbit(number_of(ctx, "-0")));
    CHECK(number_of(ctx, "1e-99999999999999999999999") == 0.0);
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_append_bytes(ctx, &text, "1", 1); // 1000 zeros, then a 1, and an exponent that compensates for them
    for (int i = 0; i < 1000; i++) gsf_append_bytes(ctx, &text, "0", 1);
    gsf_append_bytes(ctx, &text, "1e-1001", 7);
    CHECK(number_of(ctx, text.data) == 1.0);
    text.size = 0;
    gsf_append_bytes(ctx, &text, "0.", 2);
    for (int i = 0; i < 1000; i++) gsf_append_bytes(ctx, &text, "0", 1);
    gsf_append_bytes(ctx, &text, "5e1001", 6);
    CHECK(number_of(ctx, text.data) == 5.0);
    gsf_destroy_buffer(ctx, &text);
    uint64_t seed = 21;
    for (int i = 0; i < 20000; i++) { // compare with strtod in the C locale, and round-trip
        const uint64_t bits = test_random_bits(&seed);
        double value;
        memcpy(&value, &bits, sizeof value);
        if (!isfinite(value)) continue;
        char printed[64];
        snprintf(printed, sizeof printed, "%.*e", (int)(bits % 25), value);
        const double strtod_value = strtod(printed, NULL);
        if (isfinite(strtod_value)) CHECK(number_of(ctx, printed) == strtod_value);
        check_number_round_trip(ctx, value);
        check_number_round_trip(ctx, (double)(int64_t)(bits >> 40) / 1000.0);
    }
    // a locale with a decimal comma, if the system has one
    static const char* const locales[] = {"de_DE.UTF-8", "fr_FR.UTF-8", "de_DE", "nl_NL.UTF-8"};
    for (size_t i = 0; i < sizeof locales / sizeof *locales; i++)
        if (setlocale(LC_ALL, locales[i])) {
            CHECK(number_of(ctx, "1.5") == 1.5 &&
                  number_of(ctx, "1.2345678901234567890123e-5") == 1.2345678901234567890123e-5);
            check_number_round_trip(ctx, 0.1);
            setlocale(LC_ALL, "C");
        }
}

// A raw control character in a string is refused; the writer emits it as a \uXXXX escape.
static void test_json_control_characters(gsf_context* ctx) {
    for (unsigned c = 1; c < 0x20; c++) {
        const char raw[] = {'"', 'a', (char)c, 'b', '"', 0}, plain[] = {(char)c, 0};
        gsf_json json;
        CHECK_RESULT(ctx, gsf_parse_json(ctx, "raw", raw, 5, &json), GSF_ERROR_FORMAT);
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        gsf_append_json_string(ctx, &text, plain);
        char expected[16];
        snprintf(expected, sizeof expected, "\"\\u%04x\"", c);
        CHECK(strcmp(text.data, expected) == 0);
        gsf_destroy_buffer(ctx, &text);
    }
}

static void test_json_text(gsf_context* ctx) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    char all[256];
    for (int i = 1; i < 256; i++) all[i - 1] = (char)i; // from 0x80 on this sequence is not valid UTF-8
    all[255] = 0;
    gsf_append_json_string(ctx, &text, all);
    gsf_json json;
    if (CHECK_OK(ctx, gsf_parse_json(ctx, "string", text.data, text.size, &json)))
        CHECK(memcmp(json.values[0].string, all, 127) == 0 &&
              memcmp(json.values[0].string + 127, "\xef\xbf\xbd", 3) == 0);
    gsf_destroy_json(ctx, &json);
    text.size = 0;
    static const char good[] = "a\"\\\xc3\xa9\xf0\x9f\x98\x80\n";
    gsf_append_json_string(ctx, &text, good);
    if (CHECK_OK(ctx, gsf_parse_json(ctx, "string", text.data, text.size, &json)))
        CHECK(strcmp(json.values[0].string, good) == 0);
    gsf_destroy_json(ctx, &json);
    text.size = 0;
    gsf_append_json_string(ctx, &text, NULL);
    gsf_append_json_number(ctx, &text, NAN);
    gsf_append_json_number(ctx, &text, 0.1);
    CHECK(strcmp(text.data, "\"\"null0.1") == 0);
    gsf_destroy_buffer(ctx, &text);
}

// ---- images --------------------------------------------------------------------

static void test_conversions(gsf_context* ctx) {
    uint8_t bytes[256], back[256];
    float floats[256];
    double doubles[256];
    uint16_t halves[256], shorts[256];
    for (int i = 0; i < 256; i++) bytes[i] = (uint8_t)i;
    gsf_image u8 = gsf_wrap_image(bytes, GSF_U8, 256, 1, 1), out = gsf_wrap_image(back, GSF_U8, 256, 1, 1);
    const gsf_image others[] = {gsf_wrap_image(floats, GSF_F32, 256, 1, 1), gsf_wrap_image(doubles, GSF_F64, 256, 1, 1),
                                gsf_wrap_image(halves, GSF_F16, 256, 1, 1), gsf_wrap_image(shorts, GSF_U16, 256, 1, 1)};
    for (int k = 0; k < 4; k++) { // every byte value survives conversion to any type and back
        CHECK_OK(ctx, gsf_convert_image(ctx, &u8, &others[k]));
        memset(back, 0, sizeof back);
        CHECK_OK(ctx, gsf_convert_image(ctx, &others[k], &out));
        CHECK(memcmp(bytes, back, 256) == 0);
    }
    for (int i = 0; i < 256; i++) {
        CHECK(floats[i] == (float)i / 255.0f);
        CHECK(shorts[i] == 257 * i);
    }
    static const float in[] = {-1.0f, -0.0f, 0.00196078f, 0.0019608f, 0.5f,     0.999f,
                               1.0f,  7.0f,  NAN,         INFINITY,   -INFINITY};
    static const uint8_t expected[] = {0, 0, 0, 1, 128, 255, 255, 255, 0, 255, 0}; // (x*255 + 0.5), truncated
    memcpy(floats, in, sizeof in);
    gsf_image f = gsf_wrap_image(floats, GSF_F32, 11, 1, 1);
    out.width = 11;
    CHECK_OK(ctx, gsf_convert_image(ctx, &f, &out));
    for (int i = 0; i < 11; i++) CHECK(back[i] == expected[i]);
    // a fine sweep of floats: the same float32 arithmetic as torchvision
    for (int i = 0; i < 100000; i++) {
        floats[0] = (float)i / 99999.0f;
        f.width = out.width = 1;
        CHECK_OK(ctx, gsf_convert_image(ctx, &f, &out));
        const float scaled = floats[0] * 255.0f;
        CHECK(back[0] == (uint8_t)fminf(scaled + 0.5f, 255.0f));
    }
    // layouts: planar to interleaved, upside down, grey to colour, alpha dropped
    uint8_t planar[24], rgb[24], grey[6] = {1, 2, 3, 4, 5, 6}, rgba[24];
    for (int i = 0; i < 24; i++) planar[i] = rgba[i] = (uint8_t)(10 + i);
    gsf_image p = gsf_wrap_image(planar, GSF_U8, 3, 2, 3), q = gsf_wrap_image(rgb, GSF_U8, 3, 2, 3);
    p.stride_x = 1;
    p.stride_y = 3;
    p.stride_c = 6;
    CHECK_OK(ctx, gsf_convert_image(ctx, &p, &q));
    for (int i = 0; i < 6; i++)
        for (int c = 0; c < 3; c++) CHECK(rgb[3 * i + c] == planar[6 * c + i]);
    gsf_image flipped = q;
    flipped.data = rgb + 9;
    flipped.stride_y = -9;
    CHECK_OK(ctx, gsf_convert_image(ctx, &p, &flipped));
    CHECK(rgb[0] == planar[3] && rgb[9] == planar[0]);
    gsf_image g = gsf_wrap_image(grey, GSF_U8, 3, 2, 1), a = gsf_wrap_image(rgba, GSF_U8, 3, 2, 4);
    CHECK_OK(ctx, gsf_convert_image(ctx, &g, &q));
    for (int i = 0; i < 18; i++) CHECK(rgb[i] == grey[i / 3]);
    CHECK_OK(ctx, gsf_convert_image(ctx, &a, &q));
    for (int i = 0; i < 18; i++) CHECK(rgb[i] == rgba[i / 3 * 4 + i % 3]);
    CHECK_RESULT(ctx, gsf_convert_image(ctx, &q, &a), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_convert_image(ctx, &q, &g), GSF_ERROR_INVALID_ARGUMENT);
    g.width = 2;
    CHECK_RESULT(ctx, gsf_convert_image(ctx, &g, &q), GSF_ERROR_INVALID_ARGUMENT);
    g.data = NULL;
    CHECK_RESULT(ctx, gsf_convert_image(ctx, &g, &q), GSF_ERROR_INVALID_ARGUMENT);
    gsf_image made;
    CHECK_RESULT(ctx, gsf_make_image(ctx, GSF_F32, INT64_MAX, 3, 3, &made), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_make_image(ctx, GSF_F32, 0, 3, 3, &made), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_make_image(ctx, (gsf_dtype)9, 3, 3, 3, &made), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(made.data == NULL);
}

// Smooth and noisy parts.
static gsf_image noise_image(gsf_context* ctx, int64_t width, int64_t height, int32_t channels) {
    gsf_image image;
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, width, height, channels, &image));
    for (int64_t i = 0; i < width * height * channels; i++)
        ((uint8_t*)image.data)[i] = (uint8_t)(i % channels * 60 + i / channels % width * 3 +
                                              (int64_t)(gsf_draw_bits(1, 2, (uint64_t)i) & 15));
    return image;
}

// Colors change where the labels differ; alpha does not. There and back gives the same bytes, in place, too.
static void test_color_spaces(gsf_context* ctx) {
    enum { N = 256 };
    static uint8_t bytes[4 * N], again[4 * N];
    static float linear[4 * N];
    for (int i = 0; i < 4 * N; i++) bytes[i] = (uint8_t)(i / 4 + i % 4 * 85);
    const gsf_image from = gsf_wrap_image(bytes, GSF_U8, 16, 16, 4), back = gsf_wrap_image(again, GSF_U8, 16, 16, 4);
    gsf_image floats = gsf_wrap_image(linear, GSF_F32, 16, 16, 4), srgb = floats;
    floats.color_space = GSF_COLOR_LINEAR;
    CHECK_OK(ctx, gsf_convert_image(ctx, &from, &floats));
    for (int i = 0; i < 4 * N; i++) {
        const double v = bytes[i] / 255.0, wanted = i % 4 == 3 ? v : v <= 0.04045 ? v / 12.92 : pow((v + 0.055) / 1.055, 2.4);
        CHECK_NEAR(linear[i], wanted, 1e-7);
    }
    CHECK_OK(ctx, gsf_convert_image(ctx, &floats, &back));
    CHECK(memcmp(bytes, again, sizeof bytes) == 0);
    CHECK_OK(ctx, gsf_convert_image(ctx, &floats, &srgb));
    for (int i = 0; i < 4 * N; i++) CHECK_NEAR(linear[i], bytes[i] / 255.0, 1e-6);
    linear[0] = -0.5f;
    linear[1] = 4.0f;
    CHECK_OK(ctx, gsf_convert_image(ctx, &floats, &srgb));
    CHECK_NEAR(linear[0], -6.46, 1e-6);
    CHECK_NEAR(linear[1], 1.055 * pow(4.0, 1.0 / 2.4) - 0.055, 1e-6);
}

static void test_image_files(gsf_context* ctx) {
    for (int32_t channels = 1; channels <= 4; channels++) {
        gsf_image image = noise_image(ctx, 37, 23, channels), back;
        const char* path = test_scratch("image.PNG");
        CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
        int64_t w = 0, h = 0;
        int32_t c = 0;
        CHECK_OK(ctx, gsf_query_image(ctx, path, &w, &h, &c));
        CHECK(w == 37 && h == 23 && c == channels);
        CHECK_OK(ctx, gsf_load_image(ctx, path, 0, &back));
        CHECK(back.channels == channels && memcmp(back.data, image.data, (size_t)(37 * 23 * channels)) == 0);
        gsf_destroy_image(ctx, &back);
        if (channels != 2) {
            CHECK_OK(ctx, gsf_load_image(ctx, path, 3, &back));
            CHECK(back.channels == 3);
            for (int i = 0; i < 37 * 23 * 3; i++) {
                const int from = channels == 1 ? i / 3 : i / 3 * channels + i % 3;
                CHECK(((uint8_t*)back.data)[i] == ((uint8_t*)image.data)[from]);
            }
            gsf_destroy_image(ctx, &back);
            path = test_scratch("image.jpg");
            CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
            CHECK_OK(ctx, gsf_load_image(ctx, path, channels == 1 ? 1 : 3, &back));
            gsf_image rgb;
            CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, 37, 23, back.channels, &rgb));
            CHECK_OK(ctx, gsf_convert_image(ctx, &image, &rgb));
            double psnr = 0.0;
            CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &rgb, &back, NULL, &psnr));
            CHECK(psnr > 28.0 && psnr < 100.0);
            gsf_destroy_image(ctx, &rgb);
            gsf_destroy_image(ctx, &back);
        }
        gsf_destroy_image(ctx, &image);
    }
    // the other formats that stb reads, as byte arrays
    static const uint8_t pnm[] = "P6\n2 1\n255\n\x01\x02\x03\xff\xfe\xfd";
    gsf_image out;
    CHECK_OK(ctx, gsf_decode_image(ctx, "a.ppm", pnm, sizeof pnm - 1, 0, &out));
    CHECK(out.width == 2 && out.height == 1 && memcmp(out.data, pnm + 11, 6) == 0);
    gsf_destroy_image(ctx, &out);
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "a.ppm", pnm, sizeof pnm - 2, 0, &out), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "a.ppm", pnm, sizeof pnm - 1, 2, &out), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "empty", pnm, 0, 0, &out), GSF_ERROR_FORMAT);
    static const char claim[] = "P5\n16000 16000\n255\n0123456789";
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "claim.pgm", claim, sizeof claim - 1, 0, &out), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "cannot hold") != NULL);
    CHECK_RESULT(ctx, gsf_load_image(ctx, test_scratch("absent.png"), 0, &out), GSF_ERROR_NOT_FOUND);
    CHECK_RESULT(ctx, gsf_load_image(ctx, test_scratch(""), 0, &out), GSF_ERROR_IO); // a folder
    gsf_image image = noise_image(ctx, 8, 8, 3);
    CHECK_RESULT(ctx, gsf_save_image(ctx, test_scratch("image.xyz"), &image), GSF_ERROR_UNSUPPORTED);
    CHECK_RESULT(ctx, gsf_save_image(ctx, test_scratch("noextension"), &image), GSF_ERROR_UNSUPPORTED);
    gsf_destroy_image(ctx, &image);
}

// Truncated files are refused; a changed byte gives an error or an image. Blocks have exact sizes, so that ASan detects
// any overread.
static void test_damaged_images(gsf_context* ctx, heap* h) {
    static const char* const extensions[] = {".png", ".jpg"};
    const int64_t live = h->live;
    for (int k = 0; k < 2; k++) {
        gsf_image image = noise_image(ctx, 19, 17, 3), out;
        gsf_buffer file;
        memset(&file, 0, sizeof file);
        CHECK_OK(ctx, gsf_encode_image(ctx, &image, extensions[k], &file));
        for (size_t n = 0; n < file.size; n++) {
            char* copy = (char*)malloc(n ? n : 1);
            memcpy(copy, file.data, n);
            if (gsf_decode_image(ctx, "cut", copy, n, 3, &out) == GSF_OK) {
                CHECK(k == 1 && n + 2 >= file.size); // a JPEG that lacks only its end marker
                gsf_destroy_image(ctx, &out);
            } else {
                CHECK(strncmp(ctx->error, "cut:", 4) == 0 && out.data == NULL);
            }
            free(copy);
        }
        size_t accepted = 0;
        char* copy = (char*)malloc(file.size);
        for (size_t i = 0; i < file.size; i++)
            for (int change = 0; change < 3; change++) {
                memcpy(copy, file.data, file.size);
                copy[i] = (char)(change == 0 ? ~copy[i] : change == 1 ? copy[i] ^ 1 : 0x7f);
                if (gsf_decode_image(ctx, "changed", copy, file.size, 3, &out) == GSF_OK &&
                    copy[i] != file.data[i])
                    accepted++;
                gsf_destroy_image(ctx, &out);
            }
        if (k == 0) CHECK(accepted == 0); // checksums cover all of a PNG
        free(copy);
        gsf_destroy_buffer(ctx, &file);
        gsf_destroy_image(ctx, &image);
    }
    CHECK(h->live == live);
    // a PNG header that claims 16384 x 16384
    uint8_t huge[8 + 25 + 12 + 12] = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n', 0, 0, 0, 13, 'I', 'H', 'D', 'R',
                                      0, 0, 0x40, 0, 0, 0, 0x40, 0, 8, 2};
    gsf_image out;
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "huge.png", huge, sizeof huge, 3, &out), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "cannot hold") != NULL);
}

// Every input that stb would parse passes the guards first: fill bytes before a JPEG's start, pixel data that ends within
// a row's last read (all truncations, which covers reads of every length), sizes that do not fit an int. gsf_query_image
// returns the size without parsing any table.
static void test_image_guards(gsf_context* ctx) {
    gsf_image image = noise_image(ctx, 19, 17, 3), out;
    gsf_buffer file;
    memset(&file, 0, sizeof file);
    for (int i = 0; i < 300; i++) gsf_append_bytes(ctx, &file, "\xff", 1);
    CHECK_OK(ctx, gsf_encode_image(ctx, &image, ".jpg", &file));
    for (size_t fill = 0; fill <= 300; fill += fill < 4 ? 1 : 37) {
        const char* path = test_scratch("fill.jpg");
        int64_t w = 0, h = 0;
        int32_t c = 0;
        CHECK_OK(ctx, gsf_decode_image(ctx, "fill", file.data + 300 - fill, file.size - 300 + fill, 3, &out));
        CHECK(out.width == 19 && out.height == 17);
        gsf_destroy_image(ctx, &out);
        CHECK_OK(ctx, gsf_write_file(ctx, path, file.data + 300 - fill, file.size - 300 + fill));
        CHECK_OK(ctx, gsf_query_image(ctx, path, &w, &h, &c));
        CHECK(w == 19 && h == 17 && c == 3);
    }
    char bad[] = "\xff\xff\xd8\xff\xc4\x0b\x13\x00\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff";
    char* table = (char*)calloc(1, 3000);
    memcpy(table, bad, sizeof bad - 1);
    for (int fill = 0; fill < 2; fill++) { // stb without the guards writes past its arrays
        CHECK_RESULT(ctx, gsf_decode_image(ctx, "table", table + fill, (size_t)(3000 - fill), 3, &out),
                     GSF_ERROR_FORMAT);
        memcpy(table + 2836, "\xff\xc0\0\x0b\x08\0\1\0\1\1\1\x11\0", 13); // now followed by a frame header
        CHECK_RESULT(ctx, gsf_decode_image(ctx, "table", table + fill, (size_t)(3000 - fill), 3, &out),
                     GSF_ERROR_FORMAT);
        memset(table + 2836, 0, 13);
    }
    free(table);
    gsf_destroy_buffer(ctx, &file);
    gsf_destroy_image(ctx, &image);

    for (size_t n = 0; n < 600; n++) {
        char* pgm = (char*)malloc(13 + n);
        memcpy(pgm, "P5\n30 20\n255\n", 13);
        memset(pgm + 13, 77, n);
        CHECK_RESULT(ctx, gsf_decode_image(ctx, "cut.pgm", pgm, 13 + n, 0, &out), GSF_ERROR_FORMAT);
        free(pgm);
        char* tga = (char*)malloc(18 + n);
        memset(tga, 0, 18 + n);
        tga[2] = 3;
        tga[12] = 30;
        tga[14] = 20;
        tga[16] = 8;
        CHECK_RESULT(ctx, gsf_decode_image(ctx, "cut.tga", tga, 18 + n, 0, &out), GSF_ERROR_FORMAT);
        free(tga);
    }
    // A run-length TGA holds at most 64 pixels per byte: refused before 6 million pixels are decoded.
    char runs[256] = {0};
    runs[2] = 10;
    runs[13] = 0x10;
    runs[15] = 0x06;
    runs[16] = 24;
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "runs.tga", runs, sizeof runs, 0, &out), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "256 bytes cannot hold 4096 x 1536 pixels") != NULL);
    static const char wide[] = "P5\n99999999999 1\n255\nxxxxxxxxxxxxxxxx";
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "wide.pgm", wide, sizeof wide - 1, 0, &out), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "PNM header") != NULL);
}

// The PNG writer's own filters and compression, on runs, noise, repeats at distances just inside and just outside the
// DEFLATE window, and data with few distinct values. Read back with stb, which shares no code with the writer.
static void test_png_writing(gsf_context* ctx) {
    static const int64_t sizes[][2] = {{1, 1}, {700, 3}, {1, 700}, {211, 190}};
    for (int pattern = 0; pattern < 6; pattern++)
        for (int k = 0; k < 4; k++)
            for (int32_t channels = 1; channels <= 4; channels++) {
                gsf_image image, back;
                CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, sizes[k][0], sizes[k][1], channels, &image));
                uint8_t* p = (uint8_t*)image.data;
                const size_t n = (size_t)(image.stride_y * image.height);
                for (size_t i = 0; i < n; i++) {
                    const uint8_t noise = (uint8_t)gsf_draw_bits(5, 0, i);
                    p[i] = pattern == 0   ? 200
                           : pattern == 1 ? noise
                           : pattern == 2 ? (i < 32700 ? noise : p[i - 32700])
                           : pattern == 3 ? (i < 33000 ? noise : p[i - 33000])
                           : pattern == 4 ? (uint8_t)(noise % 3 ? 0 : noise)
                                          : (uint8_t)(i / 5 + i % 7 * (noise & 1));
                }
                gsf_buffer file;
                memset(&file, 0, sizeof file);
                CHECK_OK(ctx, gsf_encode_image(ctx, &image, ".png", &file));
                const size_t rows = (size_t)image.height; // one filter byte per row
                CHECK(file.size < n + rows + n / 100 + 300 && (pattern || file.size < 300 + n / 100 + rows));
                CHECK_OK(ctx, gsf_decode_image(ctx, "back", file.data, file.size, 0, &back));
                CHECK(back.channels == channels && back.width == image.width && memcmp(back.data, p, n) == 0);
                gsf_destroy_image(ctx, &back);
                gsf_destroy_buffer(ctx, &file);
                gsf_destroy_image(ctx, &image);
            }
}

#if defined(__linux__) && !defined(__SANITIZE_ADDRESS__)
#if defined(__has_feature)
#if __has_feature(address_sanitizer)
#define HAVE_NO_LIMIT // its shadow is larger than any limit
#endif
#endif
#ifndef HAVE_NO_LIMIT
#include <sys/resource.h>
#include <sys/wait.h>
// A child process that can allocate only `spare` more bytes either encodes an image or reports out of memory.
static int encode_in(size_t spare, const char* extension) {
    const pid_t child = fork();
    if (child == 0) {
        gsf_context ctx;
        gsf_image image;
        gsf_buffer file;
        unsigned long pages = 0;
        memset(&ctx, 0, sizeof ctx);
        memset(&file, 0, sizeof file);
        ctx.threads = 1;
        FILE* statm = fopen("/proc/self/statm", "r");
        if (gsf_init_context(&ctx) != GSF_OK || gsf_make_image(&ctx, GSF_U8, 1280, 720, 3, &image) != GSF_OK || !statm ||
            fscanf(statm, "%lu", &pages) != 1)
            _exit(3);
        for (size_t i = 0; i < 1280 * 720 * 3; i++) ((uint8_t*)image.data)[i] = (uint8_t)(gsf_draw_bits(1, 2, i) & 63);
        struct rlimit limit;
        limit.rlim_cur = limit.rlim_max = (rlim_t)pages * (rlim_t)sysconf(_SC_PAGESIZE) + spare;
        if (setrlimit(RLIMIT_AS, &limit) != 0) _exit(3);
        const gsf_result result = gsf_encode_image(&ctx, &image, extension, &file);
        _exit(result == GSF_OK ? 0 : result == GSF_ERROR_OUT_OF_MEMORY && strstr(ctx.error, "memory") ? 1 : 2);
    }
    int status = 0;
    if (!CHECK(child > 0 && waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) < 2))
        fprintf(stderr, "%s with %zu bytes: status %x\n", extension, spare, status);
    return WEXITSTATUS(status);
}

static void test_encoding_without_memory(void) {
    size_t refused = 0, spare = 0;
    for (; spare < (size_t)64 << 20 && encode_in(spare, ".png") == 1; spare += (size_t)1 << 19) refused++;
    CHECK(refused > 3 && spare < (size_t)64 << 20);
    for (spare = 0; spare < (size_t)16 << 20; spare += (size_t)1 << 20) (void)encode_in(spare, ".jpg");
}
#else
static void test_encoding_without_memory(void) {}
#endif
#else
static void test_encoding_without_memory(void) {}
#endif

// ---- palettes ------------------------------------------------------------------

static size_t put_little(uint8_t* at, uint32_t value, size_t bytes) {
    for (size_t i = 0; i < bytes; i++) at[i] = (uint8_t)(value >> 8 * i);
    return bytes;
}

// A picture of 4 x 1 pixels in a BMP with a header of 12 or 40 bytes; colour i is (i, 2 i, 3 i).
static size_t make_bmp(uint8_t* file, size_t header, size_t colors, uint32_t offset, const uint8_t pixels[4]) {
    size_t at = 2;
    memset(file, 0, 14 + header);
    memcpy(file, "BM", 2);
    put_little(file + 10, offset, 4);
    put_little(file + 14, (uint32_t)header, 4);
    at = 18;
    at += put_little(file + at, 4, header == 12 ? 2 : 4);
    at += put_little(file + at, 1, header == 12 ? 2 : 4);
    at += put_little(file + at, 1, 2);
    put_little(file + at, 8, 2);
    at = 14 + header;
    for (size_t i = 0; i < colors; i++) {
        const uint8_t bgr[4] = {(uint8_t)(3 * i), (uint8_t)(2 * i), (uint8_t)i, 0};
        memcpy(file + at, bgr, 4);
        at += header == 12 ? 3 : 4;
    }
    memcpy(file + at, pixels, 4);
    return at + 4;
}

static size_t put_png_chunk(uint8_t* at, const char* tag, const uint8_t* data, size_t size) {
    uint32_t crc = 0xffffffffu;
    for (int i = 0; i < 4; i++) at[i] = (uint8_t)(size >> (24 - 8 * i));
    memcpy(at + 4, tag, 4);
    if (size) memcpy(at + 8, data, size);
    for (size_t i = 4; i < 8 + size; i++) {
        crc ^= at[i];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
    }
    for (int i = 0; i < 4; i++) at[8 + size + (size_t)i] = (uint8_t)(~crc >> (24 - 8 * i));
    return size + 12;
}

// The same picture as a PNG with the given number of IDAT bytes, 16 of which hold the picture (one stored block).
static size_t make_palette_png(uint8_t* file, size_t colors, const uint8_t pixels[4], size_t bytes) {
    static const uint8_t header[13] = {0, 0, 0, 4, 0, 0, 0, 1, 8, 3, 0, 0, 0};
    static uint8_t data[70000];
    uint8_t palette[768];
    size_t at = 8;
    for (size_t i = 0; i < 3 * colors; i++) palette[i] = (uint8_t)(i / 3 * (i % 3 + 1));
    memcpy(file, "\x89PNG\r\n\x1a\n", 8);
    at += put_png_chunk(file + at, "IHDR", header, sizeof header);
    at += put_png_chunk(file + at, "PLTE", palette, 3 * colors);
    memset(data, 0, sizeof data);
    data[0] = 0x78;
    data[1] = data[2] = 1;
    put_little(data + 3, 5, 2);
    put_little(data + 5, ~5u, 2);
    memcpy(data + 8, pixels, 4); // after the row's filter byte, 0
    at += put_png_chunk(file + at, "IDAT", data, bytes);
    return at + put_png_chunk(file + at, "IEND", NULL, 0);
}

// Indices beyond the end of the palette give black, whatever memory contained; a palette size of 0 or less is refused.
static void test_palettes(gsf_context* ctx) {
    static uint8_t file[80000];
    static const uint8_t pixels[4] = {0, 1, 2, 200}, whole[4] = {0, 1, 254, 255};
    gsf_image out;
    for (int way = 0; way < 6; way++) { // BMP with either header, then PNG; each with 3 and with 256 colours
        const size_t colors = way % 2 ? 256 : 3, head = way < 2 ? 12 : 40;
        const uint32_t offset = (uint32_t)(14 + head + colors * (head == 12 ? 3 : 4));
        const uint8_t* used = way % 2 ? whole : pixels;
        const size_t size = way < 4 ? make_bmp(file, head, colors, offset, used) : make_palette_png(file, colors, used, 16);
        if (!CHECK_OK(ctx, gsf_decode_image(ctx, "palette", file, size, 3, &out))) continue;
        for (size_t i = 0; i < 4; i++)
            for (size_t c = 0; c < 3; c++)
                CHECK(((uint8_t*)out.data)[3 * i + c] == (used[i] < colors ? (uint8_t)(used[i] * (c + 1)) : 0));
        gsf_destroy_image(ctx, &out);
    }
    for (uint32_t offset = 0; offset < 58; offset++) {
        const size_t size = make_bmp(file, 40, 3, offset, pixels);
        CHECK_RESULT(ctx, gsf_decode_image(ctx, "palette", file, size, 3, &out), GSF_ERROR_FORMAT);
        if (!CHECK(out.owned == NULL)) gsf_destroy_image(ctx, &out);
    }
    const size_t size = make_palette_png(file, 3, pixels, 70000);
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "palette", file, size, 3, &out), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "more data") != NULL);
}

// ---- files ---------------------------------------------------------------------

static void check_survives(gsf_context* ctx, const char* path) {
    CHECK_RESULT(ctx, gsf_write_file(ctx, path, "new content", 11), GSF_ERROR_IO);
    CHECK(strlen(ctx->error) > 0);
    void* data = NULL;
    size_t size = 0;
    CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
    CHECK(size == 3 && memcmp(data, "old", 4) == 0);
    gsf_free(ctx, data);
}

// Only regular files are read. A pipe without a writer, a folder, a device and a link to itself fail without blocking.
static void test_unreadable_files(gsf_context* ctx) {
#ifdef __linux__
    static const char* const says[4] = {"not a regular file", "is a folder", "not a regular file", "symbolic links"};
    char paths[4][1000];
    snprintf(paths[0], sizeof paths[0], "%s", test_scratch("pipe.png"));
    snprintf(paths[1], sizeof paths[1], "%s", test_scratch("folder.png"));
    snprintf(paths[2], sizeof paths[2], "/dev/zero");
    snprintf(paths[3], sizeof paths[3], "%s", test_scratch("loop.png"));
    CHECK(mkfifo(paths[0], 0600) == 0 && mkdir(paths[1], 0700) == 0 && symlink("loop.png", paths[3]) == 0);
    for (int i = 0; i < 4; i++) {
        void* data = NULL;
        size_t size = 0;
        int64_t w = 0, h = 0;
        int32_t c = 0;
        CHECK_RESULT(ctx, gsf_read_file(ctx, paths[i], &data, &size), GSF_ERROR_IO);
        CHECK(!data && strstr(ctx->error, paths[i]) && strstr(ctx->error, says[i]));
        CHECK_RESULT(ctx, gsf_query_image(ctx, paths[i], &w, &h, &c), GSF_ERROR_IO);
        CHECK(strstr(ctx->error, paths[i]) && strstr(ctx->error, says[i]));
    }
    remove(paths[0]);
    rmdir(paths[1]);
    remove(paths[3]);
#else
    (void)ctx;
#endif
}

static void test_write_failures(gsf_context* ctx) {
    char path[1000], temporary[1010];
    snprintf(path, sizeof path, "%s", test_scratch("survivor"));
    snprintf(temporary, sizeof temporary, "%s.tmp", path);
    remove(temporary);
    CHECK_OK(ctx, gsf_write_file(ctx, path, "old", 3));
    CHECK_RESULT(ctx, gsf_write_file(ctx, "no/such/folder/file", "x", 1), GSF_ERROR_IO);
    CHECK(strstr(ctx->error, "no/such/folder/file") != NULL);
    CHECK_OK(ctx, gsf_write_file(ctx, test_scratch("nothing"), NULL, 0));
    gsf_context refusing;
    test_context_zero(&refusing);
    refusing.io = ctx->io;
    refusing.io.write_fn = no_write;
    CHECK_OK(&refusing, gsf_init_context(&refusing));
    check_survives(&refusing, path);
#ifdef __linux__
    CHECK(mkdir(temporary, 0700) == 0); // occupies the temporary's name: another one is used
    CHECK_OK(ctx, gsf_write_file(ctx, path, "old", 3));
    CHECK(rmdir(temporary) == 0);
    CHECK_RESULT(ctx, gsf_write_file(ctx, "/dev/full", "x", 1), GSF_ERROR_IO);
    CHECK(strstr(ctx->error, "/dev/full") != NULL);
    CHECK_OK(ctx, gsf_write_file(ctx, "/dev/null", "x", 1)); // a device is written to, not replaced
    struct stat info;
    CHECK(stat("/dev/null", &info) == 0 && S_ISCHR(info.st_mode));
    CHECK(stat("/dev/full", &info) == 0 && S_ISCHR(info.st_mode));
    gsf_image image = noise_image(ctx, 8, 8, 3);
    CHECK_RESULT(ctx, gsf_save_image(ctx, "no/such/folder/a.png", &image), GSF_ERROR_IO);
    gsf_destroy_image(ctx, &image);
#endif
    CHECK_OK(ctx, gsf_write_file(ctx, path, "new", 3));
}

static void test_long_files(gsf_context* ctx) { // sizes around the reader's first block
    static const size_t sizes[] = {0, 1, 65535, 65536, 65537, 131072, 200001};
    for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++) {
        char* bytes = (char*)malloc(sizes[i] + 1);
        for (size_t k = 0; k < sizes[i]; k++) bytes[k] = (char)(k * 13 >> 2);
        const char* path = test_scratch("long");
        CHECK_OK(ctx, gsf_write_file(ctx, path, bytes, sizes[i]));
        void* data = NULL;
        size_t size = 0;
        CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
        CHECK(size == sizes[i] && memcmp(data, bytes, size) == 0 && ((char*)data)[size] == 0);
        gsf_free(ctx, data);
        free(bytes);
    }
}

// ---- random numbers ------------------------------------------------------------

static void test_random_statistics(void) {
    enum { N = 1 << 18, BINS = 256 };
    static double u[N];
    for (uint64_t stream = 0; stream < 4; stream++) {
        double count[BINS] = {0}, moments[5] = {0}, serial = 0.0, ones[64] = {0}, chi = 0.0;
        for (uint64_t i = 0; i < N; i++) {
            u[i] = gsf_draw_uniform(42, stream, i);
            CHECK(u[i] >= 0.0 && u[i] < 1.0);
            count[(int)(u[i] * BINS)] += 1.0;
            if (i) serial += (u[i] - 0.5) * (u[i - 1] - 0.5);
            const uint64_t bits = gsf_draw_bits(42, stream, i);
            for (int b = 0; b < 64; b++) ones[b] += (double)(bits >> b & 1u);
            const double n = gsf_draw_normal(7, stream, i);
            double power = 1.0;
            for (int k = 1; k <= 4; k++) moments[k] += power *= n;
        }
        for (int b = 0; b < BINS; b++) chi += pow(count[b] - N / BINS, 2.0) / (N / BINS);
        CHECK(chi > 255 - 6 * sqrt(510.0) && chi < 255 + 6 * sqrt(510.0)); // within 6 sigma
        CHECK_NEAR(serial / N * 12.0, 0.0, 6.0 / sqrt(N));
        for (int b = 0; b < 64; b++) CHECK_NEAR(ones[b] / N, 0.5, 3.0 / sqrt(N));
        CHECK_NEAR(moments[1] / N, 0.0, 6.0 / sqrt(N));
        CHECK_NEAR(moments[2] / N, 1.0, 6.0 * sqrt(2.0 / N));
        CHECK_NEAR(moments[3] / N, 0.0, 6.0 * sqrt(15.0 / N));
        CHECK_NEAR(moments[4] / N, 3.0, 6.0 * sqrt(96.0 / N));
    }
    double across = 0.0, seeds = 0.0; // neighbouring streams and seeds, also swapped, are uncorrelated
    int swapped = 0;
    for (uint64_t i = 0; i < N; i++) {
        across += (gsf_draw_uniform(1, i, 0) - 0.5) * (gsf_draw_uniform(1, i + 1, 0) - 0.5);
        seeds += (gsf_draw_uniform(i, 0, 0) - 0.5) * (gsf_draw_uniform(i + 1, 0, 0) - 0.5);
        swapped += gsf_draw_bits(i, 5, 9) == gsf_draw_bits(5, i, 9) && i != 5;
    }
    CHECK_NEAR(across / N * 12.0, 0.0, 6.0 / sqrt(N));
    CHECK_NEAR(seeds / N * 12.0, 0.0, 6.0 / sqrt(N));
    CHECK(swapped == 0);
}

// ---- cameras -------------------------------------------------------------------

static gsf_camera any_camera(uint64_t* seed) {
    double q[4], norm = 0.0;
    for (int k = 0; k < 4; k++) {
        q[k] = test_random_in(seed, -1, 1);
        norm += q[k] * q[k];
    }
    for (int k = 0; k < 4; k++) q[k] /= sqrt(norm);
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    gsf_camera camera = plain_camera();
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
                         2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                         2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)};
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < 3; k++) camera.w2c[4 * c + k] = r[3 * c + k];
    for (int k = 0; k < 3; k++) camera.w2c[12 + k] = test_random_in(seed, -1e6, 1e6);
    camera.fx = test_random_in(seed, 100, 2000);
    camera.cx = test_random_in(seed, -50, 800);
    return camera;
}

static void test_camera_functions(gsf_context* ctx) {
    uint64_t seed = 4;
    for (int i = 0; i < 100; i++) {
        const gsf_camera camera = any_camera(&seed);
        CHECK_OK(ctx, gsf_check_camera(ctx, &camera));
        double c2w[16], identity[16], unit[16] = {0}, center[3];
        gsf_get_camera_c2w(&camera, c2w);
        gsf__mat4_mul(camera.w2c, c2w, identity);
        for (int k = 0; k < 4; k++) unit[5 * k] = 1.0;
        test_compare("w2c c2w", identity, unit, 16, 1e-8); // translations are up to 1e6
        gsf_camera again = camera;
        gsf_set_camera_c2w(&again, c2w);
        test_compare("set_c2w", again.w2c, camera.w2c, 16, 1e-8);
        gsf_get_camera_center(&camera, center);
        CHECK(memcmp(center, c2w + 12, sizeof center) == 0);
        const gsf_camera half = gsf_resize_camera(&camera, 320, 120);
        double point[3], u = 0, v = 0, d = 0, hu = 0, hv = 0, hd = 0;
        for (int k = 0; k < 3; k++) point[k] = center[k] + 3.0 * c2w[8 + k] + 0.5 * c2w[k] - 0.25 * c2w[4 + k];
        CHECK(gsf_project_point(&camera, point, &u, &v, &d) && gsf_project_point(&half, point, &hu, &hv, &hd));
        CHECK_NEAR(d, 3.0, 1e-8);
        CHECK_NEAR(u, camera.cx + camera.fx * 0.5 / 3.0, 1e-5);
        CHECK_NEAR(v, camera.cy - camera.fy * 0.25 / 3.0, 1e-5);
        CHECK_NEAR(hu, u / 2, 1e-9 * fabs(u));
        CHECK_NEAR(hv, v / 4, 1e-9 * fabs(v));
    }
    gsf_camera bad = plain_camera();
    bad.w2c[5] = NAN;
    CHECK_RESULT(ctx, gsf_check_camera(ctx, &bad), GSF_ERROR_NUMERIC);
    bad = plain_camera();
    bad.w2c[0] = -1.0; // a reflection
    CHECK_RESULT(ctx, gsf_check_camera(ctx, &bad), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx->error, "reflection") != NULL);
    bad = plain_camera();
    bad.w2c[10] = 1.1;
    CHECK_RESULT(ctx, gsf_check_camera(ctx, &bad), GSF_ERROR_INVALID_ARGUMENT);
    bad = plain_camera();
    bad.w2c[3] = 0.1;
    CHECK_RESULT(ctx, gsf_check_camera(ctx, &bad), GSF_ERROR_INVALID_ARGUMENT);
    bad = plain_camera();
    bad.fy = 0.0;
    CHECK_RESULT(ctx, gsf_check_camera(ctx, &bad), GSF_ERROR_INVALID_ARGUMENT);
    bad = plain_camera();
    bad.height = 0;
    CHECK_RESULT(ctx, gsf_check_camera(ctx, &bad), GSF_ERROR_INVALID_ARGUMENT);
}

static void test_camera_files(gsf_context* ctx) {
    enum { COUNT = 20 };
    gsf_camera cameras[COUNT], *back = NULL;
    const char* names[COUNT];
    uint64_t seed = 8;
    for (int i = 0; i < COUNT; i++) {
        cameras[i] = any_camera(&seed);
        names[i] = i % 3 ? "na\"me \xc3\xa9.png" : NULL;
    }
    size_t count = 0;
    const char* path = test_scratch("cameras.json");
    CHECK_OK(ctx, gsf_save_cameras(ctx, path, cameras, names, COUNT));
    if (CHECK_OK(ctx, gsf_load_cameras(ctx, path, &back, &count)) && CHECK(count == COUNT))
        for (int i = 0; i < COUNT; i++) { // bit for bit (no padding bytes are compared)
            CHECK(memcmp(back[i].w2c, cameras[i].w2c, sizeof back[i].w2c) == 0);
            CHECK(back[i].fx == cameras[i].fx && back[i].fy == cameras[i].fy && back[i].cx == cameras[i].cx);
            CHECK(back[i].cy == cameras[i].cy && back[i].width == 640 && back[i].height == 480);
        }
    gsf_free(ctx, back);
    CHECK_OK(ctx, gsf_save_cameras(ctx, path, NULL, NULL, 0));
    CHECK_OK(ctx, gsf_load_cameras(ctx, path, &back, &count));
    CHECK(count == 0);
    gsf_free(ctx, back);
    cameras[1].fx = NAN;
    CHECK(gsf_save_cameras(ctx, path, cameras, names, 2) != GSF_OK && strstr(ctx->error, "camera 1") != NULL);

#define M "[1,0,0,0.5,0,1,0,2,0,0,1,3,0,0,0,1]"
    static const char good[] =
        "{\"x\":1,\"cameras\":[{\"w2c\":" M ",\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4,\"height\":3}]}";
    static const char* const bad[] = {
        "[]", "{}", "{\"cameras\":{}}", "{\"cameras\":[1]}", "{\"cameras\":[{}]}",
        "{\"cameras\":[{\"w2c\":[1,2],\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4,\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,null],\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4,"
        "\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":[2,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1],\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4,"
        "\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":" M ",\"fx\":\"1\",\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4,\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":" M ",\"fx\":-1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4,\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":" M ",\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4.5,\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":" M ",\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":3000000000,\"height\":3}]}",
        "{\"cameras\":[{\"w2c\":" M ",\"fx\":1,\"fy\":1,\"cx\":0,\"cy\":0,\"width\":4}]}"};
    CHECK_OK(ctx, gsf_write_file(ctx, path, good, sizeof good - 1));
    CHECK_OK(ctx, gsf_load_cameras(ctx, path, &back, &count));
    CHECK(count == 1 && back[0].w2c[12] == 0.5 && back[0].w2c[13] == 2.0 && back[0].w2c[14] == 3.0); // row-major file
    gsf_free(ctx, back);
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        CHECK_OK(ctx, gsf_write_file(ctx, path, bad[i], strlen(bad[i])));
        CHECK_RESULT(ctx, gsf_load_cameras(ctx, path, &back, &count), GSF_ERROR_FORMAT);
        CHECK(back == NULL && count == 0 && strstr(ctx->error, "cameras.json:") != NULL);
    }
}

int main(void) {
    gsf_context ctx;
    heap h;
    init_with_heap(&ctx, &h);
    test_hooks();
    test_base_out_of_memory();
    test_damaged_chunks(&ctx);
    test_json_conformance(&ctx);
    test_json_values(&ctx);
    test_json_numbers(&ctx);
    test_json_text(&ctx);
    test_json_control_characters(&ctx);
    test_conversions(&ctx);
    test_color_spaces(&ctx);
    test_image_files(&ctx);
    test_damaged_images(&ctx, &h);
    test_image_guards(&ctx);
    test_palettes(&ctx);
    test_png_writing(&ctx);
    test_encoding_without_memory();
    test_unreadable_files(&ctx);
    test_write_failures(&ctx);
    test_long_files(&ctx);
    test_random_statistics();
    test_camera_functions(&ctx);
    test_camera_files(&ctx);
    CHECK(h.live == 0);
    return test_report();
}
