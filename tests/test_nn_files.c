// Weight files of gsfixer_nn.h: safetensors, single and sharded, and PyTorch files, valid and damaged; and the weight loader
// of the networks.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

#if defined(__unix__) || defined(__APPLE__)
#include <sys/stat.h>
#define HAS_FOLDERS 1
static void make_folder(const char* path) { (void)mkdir(path, 0777); }
#elif defined(_WIN32)
#include <direct.h>
#define HAS_FOLDERS 1
static void make_folder(const char* path) { (void)_mkdir(path); }
#else
#define HAS_FOLDERS 0
#endif

// A safetensors file in a block of exactly its size: header text, then `data` bytes 0, 1, 2, ...
typedef struct made { unsigned char* data; size_t size; } made;

static made make_file(const char* header, size_t data) {
    const size_t n = strlen(header);
    made m;
    m.size = 8 + n + data;
    m.data = (unsigned char*)malloc(m.size);
    for (int i = 0; i < 8; i++) m.data[i] = (unsigned char)((uint64_t)n >> 8 * i);
    memcpy(m.data + 8, header, n);
    for (size_t i = 0; i < data; i++) m.data[8 + n + i] = (unsigned char)i;
    return m;
}

// ---- round trips

enum { ALL = 11 };

static void make_tensors(gsf_nn_tensor t[ALL]) { // every dtype; ranks 0 to 8; empty tensors; odd sizes
    static const char* const names[ALL] = {"f32", "bf16", "f16", "f64",   "u8",          "i8",
                                           "i16", "i32",  "i64", "empty", "\xc3\xa9\"\n"};
    static const int64_t shapes[ALL][8] = {{2, 3}, {5}, {3}, {0}, {1, 1, 1, 1, 1, 1, 1, 3}, {7},
                                           {3, 1}, {2}, {2}, {4, 0, 2}, {1}};
    static const int32_t ranks[ALL] = {2, 1, 1, 0, 8, 1, 2, 1, 1, 3, 1};
    static unsigned char bytes[ALL][64];
    for (int i = 0; i < ALL; i++) {
        memset(&t[i], 0, sizeof t[i]);
        t[i].name = names[i];
        t[i].dtype = i < 9 ? (gsf_nn_dtype)i : i == 9 ? GSF_NN_F32 : GSF_NN_U8;
        t[i].rank = ranks[i];
        t[i].count = 1;
        for (int k = 0; k < ranks[i]; k++) t[i].count *= t[i].shape[k] = shapes[i][k];
        for (int k = 0; k < 64; k++) bytes[i][k] = (unsigned char)(17 * i + 31 * k + 5);
        t[i].data = bytes[i];
    }
}

static void check_same(const gsf_nn_weights* w, const gsf_nn_tensor* expected, size_t count) {
    CHECK(w->tensor_count == count);
    for (size_t i = 1; i < w->tensor_count; i++) CHECK(strcmp(w->tensors[i - 1].name, w->tensors[i].name) < 0);
    for (size_t i = 0; i < count; i++) {
        const gsf_nn_tensor *e = &expected[i], *t = gsf_nn_find_tensor(w, e->name);
        if (!CHECK(t != NULL)) continue;
        CHECK(t->dtype == e->dtype && t->rank == e->rank && t->count == e->count);
        CHECK(memcmp(t->shape, e->shape, sizeof t->shape) == 0);
        CHECK(memcmp(t->data, e->data, (size_t)e->count * gsf_nn_get_dtype_size(e->dtype)) == 0);
    }
    CHECK(gsf_nn_find_tensor(w, "") == NULL && gsf_nn_find_tensor(w, "f3") == NULL && gsf_nn_find_tensor(w, "zzz") == NULL);
}

static gsf_result hooked_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    FILE* file = fopen(path, "rb");
    ++*(int*)user;
    if (!file) return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: not there", path);
    fseek(file, 0, SEEK_END);
    *size = (size_t)ftell(file);
    rewind(file);
    *data = gsf_alloc(ctx, *size, 1);
    const size_t got = *data ? fread(*data, 1, *size, file) : 0;
    fclose(file);
    return got == *size ? GSF_OK : GSF_ERROR_IO;
}
static gsf_result hooked_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user, (void)path, (void)data, (void)size;
    return gsf_fail(ctx, GSF_ERROR_IO, "read only");
}

static void test_round_trip(gsf_context* ctx) {
    gsf_nn_tensor tensors[ALL];
    make_tensors(tensors);
    const char* path = test_scratch("all.safetensors");
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, ALL));
    gsf_nn_weights w;
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, path, NULL, &w))) return;
    check_same(&w, tensors, ALL);
    CHECK(HAS_FOLDERS ? w.mapped_bytes > 0 && w.read_bytes == 0 : w.read_bytes > 0);
    for (size_t i = 0; i < w.tensor_count; i++) // tensors in files written by the library are aligned
        CHECK((uintptr_t)w.tensors[i].data % gsf_nn_get_dtype_size(w.tensors[i].dtype) == 0);
    gsf_nn_destroy_weights(ctx, &w);
    CHECK(w.tensors == NULL && w.tensor_count == 0);
    gsf_nn_destroy_weights(ctx, &w);

    size_t size; // opened from memory, at every alignment
    char* data = test_read_file(path, &size);
    for (size_t shift = 0; shift < 8; shift++) {
        char* moved = (char*)malloc(size + shift);
        memcpy(moved + shift, data, size);
        if (CHECK_OK(ctx, gsf_nn_parse_weights(ctx, "moved", moved + shift, size, &w))) {
            check_same(&w, tensors, ALL);
            CHECK(w.mapped_bytes == 0 && w.read_bytes == 0);
            float values[8];
            for (size_t i = 0; i < w.tensor_count; i++) gsf_nn_convert_tensor(&w.tensors[i], 0, w.tensors[i].count,
                                                                              values);
            gsf_nn_destroy_weights(ctx, &w);
        }
        free(moved);
    }
    // the header is padded to a multiple of 8 bytes
    CHECK(memcmp(data + 8, "{\"", 2) == 0 && ((unsigned char)data[0] & 7) == 0);
    free(data);

    int calls = 0; // through the host's io hook
    gsf_context hooked;
    test_context_zero(&hooked);
    hooked.io.read_fn = hooked_read;
    hooked.io.write_fn = hooked_write;
    hooked.io.user = &calls;
    CHECK_OK(&hooked, gsf_init_context(&hooked));
    if (CHECK_OK(&hooked, gsf_nn_load_weights(&hooked, path, NULL, &w))) {
        check_same(&w, tensors, ALL);
        CHECK(calls == 1 && w.mapped_bytes == 0 && w.read_bytes == size);
        gsf_nn_destroy_weights(&hooked, &w);
    }
    CHECK_RESULT(&hooked, gsf_nn_save_tensors(&hooked, path, tensors, ALL), GSF_ERROR_IO);
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("none.safetensors"), NULL, 0)); // a file without tensors
    if (CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_scratch("none.safetensors"), NULL, &w))) {
        CHECK(w.tensor_count == 0 && gsf_nn_find_tensor(&w, "x") == NULL);
        gsf_nn_destroy_weights(ctx, &w);
    }
}

static void test_bad_save(gsf_context* ctx) {
    const char* path = test_scratch("bad.safetensors");
    gsf_nn_tensor tensors[ALL];
    for (int fault = 0; fault < 8; fault++) {
        make_tensors(tensors);
        switch (fault) {
            case 0: tensors[1].name = "f32"; break;
            case 1: tensors[1].name = NULL; break;
            case 2: tensors[1].name = "\xff"; break;
            case 3: tensors[1].name = "__metadata__"; break;
            case 4: tensors[1].count = 6; break;
            case 5: tensors[1].data = NULL; break;
            case 6: tensors[1].rank = 9; break;
            case 7: tensors[1].shape[0] = -5; break;
        }
        CHECK_RESULT(ctx, gsf_nn_save_tensors(ctx, path, tensors, ALL), GSF_ERROR_INVALID_ARGUMENT);
    }
}

// a header whose size is no multiple of 8, and dtypes that are converted to others
static void test_values(gsf_context* ctx) {
    made m = make_file("{\"a\":{\"dtype\":\"I16\",\"shape\":[3],\"data_offsets\":[1,7]},"
                       "\"b\" : {\"shape\":[],\"more\":[1,{}],\"dtype\":\"BOOL\",\"data_offsets\":[0,1]},"
                       "\"__metadata__\":{\"k\":\"v\"}} ", 7);
    CHECK(m.size % 8 != 7);
    gsf_nn_weights w;
    if (CHECK_OK(ctx, gsf_nn_parse_weights(ctx, "values", m.data, m.size, &w)) && CHECK(w.tensor_count == 2)) {
        float v[3];
        CHECK(w.tensors[1].dtype == GSF_NN_U8 && w.tensors[1].rank == 0 && w.tensors[1].count == 1);
        gsf_nn_convert_tensor(&w.tensors[1], 0, 1, v);
        CHECK(v[0] == 0.0f);
        gsf_nn_convert_tensor(&w.tensors[0], 0, 3, v);
        CHECK(v[0] == 513.0f && v[1] == 1027.0f && v[2] == 1541.0f);
        gsf_nn_convert_tensor(&w.tensors[0], 1, 2, v);
        CHECK(v[0] == 1027.0f && v[1] == 1541.0f);
    }
    gsf_nn_destroy_weights(ctx, &w);
    free(m.data);
}

// ---- damaged files

typedef struct broken {
    const char* header;
    size_t data;
    gsf_result result;
    const char* text; // expected part of the error message
} broken;

#define ENTRY(dtype, shape, offsets) "{\"x\":{\"dtype\":" dtype ",\"shape\":" shape ",\"data_offsets\":" offsets "}}"

#define TWO(shape0, offsets0, shape1, offsets1)                                       \
    "{\"x\":{\"dtype\":\"U8\",\"shape\":" shape0 ",\"data_offsets\":" offsets0 "}," \
    "\"y\":{\"dtype\":\"U8\",\"shape\":" shape1 ",\"data_offsets\":" offsets1 "}}"

static const broken broken_files[] = {
    {"", 0, GSF_ERROR_FORMAT, "f:8: the header does not begin"},
    {" {}", 0, GSF_ERROR_FORMAT, "f:8: the header does not begin"},
    {"[]", 0, GSF_ERROR_FORMAT, "f:8: the header does not begin"},
    {"{} x", 0, GSF_ERROR_FORMAT, "f:11: expected the end"},
    {"{\"x\":1}", 0, GSF_ERROR_FORMAT, "f:13: tensor x: not an object"},
    {"{\"x\":{}}", 0, GSF_ERROR_FORMAT, "f:13: tensor x: \"dtype\""},
    {"{}", 3, GSF_ERROR_FORMAT, "f:10: 3 bytes belong to no tensor"},
    {"{\"__metadata__\":1}", 0, GSF_ERROR_FORMAT, "f:24: __metadata__"},
    {"{\"__metadata__\":{\"a\":1}}", 0, GSF_ERROR_FORMAT, "__metadata__"},
    {"{\"x\":{\"dtype\":\"F32\"},\"x\":{}}", 0, GSF_ERROR_FORMAT, "key \"x\" occurs twice"},
    {"{\"x\xff\":{}}", 0, GSF_ERROR_FORMAT, "UTF-8"},
    {"{\"x\\u0000y\":{}}", 0, GSF_ERROR_FORMAT, "zero byte"},
    {ENTRY("\"F8_E4M3\"", "[4]", "[0,4]"), 4, GSF_ERROR_UNSUPPORTED, "tensor x: dtype F8_E4M3"},
    {ENTRY("\"C64\"", "[1]", "[0,8]"), 8, GSF_ERROR_UNSUPPORTED, "tensor x: dtype C64"},
    {ENTRY("\"U16\"", "[1]", "[0,2]"), 2, GSF_ERROR_UNSUPPORTED, "f:22: tensor x: dtype U16"},
    {ENTRY("\"f32\"", "[1]", "[0,4]"), 4, GSF_ERROR_UNSUPPORTED, "dtype f32"},
    {ENTRY("3", "[1]", "[0,4]"), 4, GSF_ERROR_FORMAT, "\"dtype\" is not"},
    {ENTRY("\"F32\"", "1", "[0,4]"), 4, GSF_ERROR_FORMAT, "\"shape\" is not"},
    {ENTRY("\"F32\"", "[-1]", "[0,4]"), 4, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[-0]", "[0,0]"), 0, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[1.0]", "[0,4]"), 4, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[1e0]", "[0,4]"), 4, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[\"1\"]", "[0,4]"), 4, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[9223372036854775808]", "[0,4]"), 4, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[99999999999999999999999999]", "[0,4]"), 4, GSF_ERROR_FORMAT, "a dimension"},
    {ENTRY("\"F32\"", "[4294967296,4294967296]", "[0,4]"), 4, GSF_ERROR_FORMAT, "overflows"},
    {ENTRY("\"F32\"", "[4294967296,4294967296,0]", "[0,0]"), 0, GSF_ERROR_FORMAT, "overflows"},
    {ENTRY("\"F64\"", "[9223372036854775807]", "[0,8]"), 8, GSF_ERROR_FORMAT, "values of F64"},
    // 8 n overflows to 8 (mod 2^64)
    {ENTRY("\"F64\"", "[2305843009213693953]", "[0,8]"), 8, GSF_ERROR_FORMAT, "values of F64"},
    {ENTRY("\"U8\"", "[1,1,1,1,1,1,1,1,1]", "[0,1]"), 1, GSF_ERROR_UNSUPPORTED, "8 dimensions"},
    {ENTRY("\"F32\"", "[1]", "[0]"), 4, GSF_ERROR_FORMAT, "two non-negative integers"},
    {ENTRY("\"F32\"", "[1]", "[0,4,4]"), 4, GSF_ERROR_FORMAT, "two non-negative integers"},
    {ENTRY("\"F32\"", "[1]", "[0,-4]"), 4, GSF_ERROR_FORMAT, "two non-negative integers"},
    {ENTRY("\"F32\"", "[1]", "[0.5,4]"), 4, GSF_ERROR_FORMAT, "two non-negative integers"},
    {ENTRY("\"F32\"", "[1]", "null"), 4, GSF_ERROR_FORMAT, "two non-negative integers"},
    {ENTRY("\"F32\"", "[1]", "[4,0]"), 4, GSF_ERROR_FORMAT, "are outside"},
    {ENTRY("\"F32\"", "[2]", "[0,8]"), 4, GSF_ERROR_FORMAT, "f:55: tensor x: bytes 0 to 8 are outside the 4 bytes"},
    {ENTRY("\"U8\"", "[10000000000]", "[0,10000000000]"), 4, GSF_ERROR_FORMAT, "are outside the 4 bytes"},
    {ENTRY("\"F32\"", "[2]", "[0,4]"), 4, GSF_ERROR_FORMAT, "4 bytes for 2 values of F32"},
    {ENTRY("\"U8\"", "[2]", "[1,3]"), 3, GSF_ERROR_FORMAT, "tensor x follows bytes that belong to no tensor"},
    {ENTRY("\"U8\"", "[2]", "[0,2]"), 3, GSF_ERROR_FORMAT, "1 bytes belong to no tensor"},
    {TWO("[2]", "[0,2]", "[2]", "[1,3]"), 3, GSF_ERROR_FORMAT, "tensor y overlaps"},
    {TWO("[2]", "[0,2]", "[1]", "[3,4]"), 4, GSF_ERROR_FORMAT, "tensor y follows bytes"},
    {TWO("[0]", "[1,1]", "[2]", "[0,2]"), 2, GSF_ERROR_FORMAT, "tensor x overlaps"},
};

static void test_broken(gsf_context* ctx) {
    gsf_nn_weights w;
    for (size_t i = 0; i < GSF__COUNT(broken_files); i++) {
        const broken* b = &broken_files[i];
        made m = make_file(b->header, b->data);
        const int ok = CHECK_RESULT(ctx, gsf_nn_parse_weights(ctx, "f", m.data, m.size, &w), b->result);
        if (ok && !CHECK(strncmp(ctx->error, "f:", 2) == 0 && strstr(ctx->error, b->text) != NULL))
            fprintf(stderr, "  %s: \"%s\" is not in \"%s\"\n", b->header, b->text, ctx->error);
        CHECK(w.tensors == NULL && w.tensor_count == 0 && w.files == NULL);
        free(m.data);
    }
    static const uint64_t claims[] = {3, 100000001, 10000000000u, UINT64_MAX, UINT64_MAX - 7};
    for (size_t i = 0; i < GSF__COUNT(claims); i++) { // the size of the header
        made m = make_file("{}", 0);
        for (int k = 0; k < 8; k++) m.data[k] = (unsigned char)(claims[i] >> 8 * k);
        CHECK_RESULT(ctx, gsf_nn_parse_weights(ctx, "f", m.data, m.size, &w), GSF_ERROR_FORMAT);
        CHECK(strstr(ctx->error, "f:0: a header of") != NULL);
        free(m.data);
    }
    gsf_buffer deep; // nesting depth
    memset(&deep, 0, sizeof deep);
    gsf_append_bytes(ctx, &deep, "{\"x\":", 5);
    for (int i = 0; i < 200; i++) gsf_append_bytes(ctx, &deep, "[", 1);
    made m = make_file(deep.data, 0);
    CHECK_RESULT(ctx, gsf_nn_parse_weights(ctx, "f", m.data, m.size, &w), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "levels deep") != NULL);
    gsf_destroy_buffer(ctx, &deep);
    free(m.data);
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, test_scratch("absent.safetensors"), NULL, &w), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "absent.safetensors") != NULL);
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, test_scratch("absent"), NULL, &w), GSF_ERROR_NOT_FOUND);
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, test_scratch("absent"), "model", &w), GSF_ERROR_NOT_FOUND);
    CHECK_OK(ctx, gsf_write_file(ctx, test_scratch("empty.safetensors"), "", 0));
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, test_scratch("empty.safetensors"), NULL, &w), GSF_ERROR_FORMAT);
}

// The data of accepted tensors lies inside the file.
static void read_all(const gsf_nn_weights* w) {
    float sum = 0.0f, value;
    for (size_t i = 0; i < w->tensor_count; i++)
        for (int64_t k = 0; k < w->tensors[i].count; k++) {
            gsf_nn_convert_tensor(&w->tensors[i], k, 1, &value);
            sum += value;
        }
    CHECK(sum == sum || sum != sum);
}

static void test_cut_and_flipped(gsf_context* ctx) {
    gsf_nn_tensor tensors[ALL];
    gsf_nn_weights w;
    size_t size;
    make_tensors(tensors);
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("flip.safetensors"), tensors, ALL));
    char* data = test_read_file(test_scratch("flip.safetensors"), &size);
    for (size_t cut = 0; cut < size; cut++) { // every truncated length, in a block of exactly that size
        unsigned char* part = (unsigned char*)malloc(cut ? cut : 1);
        memcpy(part, data, cut);
        CHECK_RESULT(ctx, gsf_nn_parse_weights(ctx, "cut", part, cut, &w), GSF_ERROR_FORMAT);
        CHECK(strncmp(ctx->error, "cut:", 4) == 0);
        free(part);
    }
    unsigned char* copy = (unsigned char*)malloc(size);
    const size_t end = 8 + (size_t)gsf__load_le(data, 8);
    static const unsigned char masks[] = {0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x40, 0x80, 0xff, 0x41};
    size_t accepted = 0, refused = 0;
    for (size_t i = 0; i < end; i++)
        for (size_t k = 0; k < GSF__COUNT(masks); k++) {
            memcpy(copy, data, size);
            copy[i] ^= masks[k];
            const gsf_result r = gsf_nn_parse_weights(ctx, "flip", copy, size, &w);
            CHECK(r == GSF_OK || r == GSF_ERROR_FORMAT || r == GSF_ERROR_UNSUPPORTED);
            CHECK(r == GSF_OK || strncmp(ctx->error, "flip:", 5) == 0);
            if (r == GSF_OK) read_all(&w);
            *(r == GSF_OK ? &accepted : &refused) += 1;
            gsf_nn_destroy_weights(ctx, &w);
        }
    CHECK(refused > 5 * accepted && accepted > 0); // only changed letters of names can be accepted
    free(copy);
    free(data);
}

// ---- PyTorch files; their values: golden_metricnets

// Every truncated length, and every byte changed, in blocks of exactly the size.
static void test_pth_damaged(gsf_context* ctx, const char* name) {
    static const unsigned char masks[] = {0x01, 0x10, 0x80, 0xff};
    gsf_nn_weights w;
    size_t size, refused = 0;
    char* data = test_read_file(test_golden(name), &size);
    unsigned char* part = NULL;
    for (size_t cut = 0; cut < size; cut++) {
        part = (unsigned char*)malloc(cut ? cut : 1);
        memcpy(part, data, cut);
        CHECK_RESULT(ctx, gsf_nn_parse_weights(ctx, "cut", part, cut, &w), GSF_ERROR_FORMAT);
        CHECK(strncmp(ctx->error, "cut:", 4) == 0);
        free(part);
    }
    part = (unsigned char*)malloc(size);
    for (size_t i = 0; i < size; i++)
        for (size_t k = 0; k < GSF__COUNT(masks); k++) {
            memcpy(part, data, size);
            part[i] ^= masks[k];
            const gsf_result r = gsf_nn_parse_weights(ctx, "flip", part, size, &w);
            CHECK(r == GSF_OK || r == GSF_ERROR_FORMAT || r == GSF_ERROR_UNSUPPORTED);
            CHECK(r == GSF_OK || strncmp(ctx->error, "flip:", 5) == 0);
            if (r == GSF_OK) read_all(&w);
            refused += r != GSF_OK;
            gsf_nn_destroy_weights(ctx, &w);
        }
    CHECK(refused > size / 2);
    free(part);
    free(data);
}

// A legacy file around an object's pickle; one float storage "0" of `count` elements 0, 1, 2, ...
static made make_pth(const char* pickle, size_t pickle_size, size_t count) {
    static const char head[] = "\x80\2\x8a\12\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.\x80\2M\xe9\3.\x80\2}.";
    static const char keys[] = "\x80\2](U\0010e.";
    made m;
    m.size = sizeof head - 1 + pickle_size + (count ? sizeof keys - 1 + 8 + 4 * count : 4);
    m.data = (unsigned char*)malloc(m.size);
    unsigned char* p = m.data;
    memcpy(p, head, sizeof head - 1), p += sizeof head - 1;
    memcpy(p, pickle, pickle_size), p += pickle_size;
    if (!count) memcpy(p, "\x80\2].", 4);
    else memcpy(p, keys, sizeof keys - 1), p += sizeof keys - 1;
    for (size_t i = 0; i < 8 && count; i++) *p++ = (unsigned char)(count >> 8 * i);
    for (size_t i = 0; i < count; i++, p += 4) {
        const float value = (float)i;
        memcpy(p, &value, 4);
    }
    return m;
}

#define PTH_STORAGE "(U\7storagectorch\nFloatStorage\nU\0010U\3cpuK\6tQ"
#define PTH_TENSOR(dims) "ctorch._utils\n_rebuild_tensor_v2\n(" PTH_STORAGE dims "\x89}tR" // six elements
#define PTH_2X3 PTH_TENSOR("K\0K\2K\3\x86K\3K\1\x86")

static void test_pth(gsf_context* ctx) {
    static const struct { const char* pickle; size_t size, storage; const char *text, *names; } cases[] = {
#define PTH_CASE(pickle, storage, text, names) {"\x80\2" pickle ".", sizeof pickle + 2, storage, text, names}
        PTH_CASE("}(U\1a" PTH_2X3 "u", 6, NULL, "a"),
        PTH_CASE("}(U\5state}(U\1a" PTH_2X3 "uU\1x}(U\1bK\1uu", 6, NULL, "a"),               // the common part is omitted
        PTH_CASE("}(U\5state}(U\1a" PTH_2X3 "uU\1b" PTH_2X3 "u", 6, NULL, "b state/a"),
        PTH_CASE("}(U\1a" PTH_2X3 "2u", 6, "a key without a value", NULL),
        PTH_CASE("}(U\1aNK\7" PTH_2X3 "q\0U\1bh\0u", 6, NULL, "7 b"),                         // one tensor, two names
        PTH_CASE("ccollections\nOrderedDict\n(]U\1a" PTH_2X3 "\x86" "a\x85tR", 6, "of no pairs", NULL),
        PTH_CASE("ccollections\nOrderedDict\n]](U\1a" PTH_2X3 "ea\x85R", 6, NULL, "a"),         // as Python 2 writes it
        PTH_CASE("}(U\1a" PTH_2X3 "U\1a" PTH_2X3 "u", 6, "two tensors are called a", NULL),
        PTH_CASE("}(}" PTH_2X3 "u", 6, "without a name", NULL),
        PTH_CASE("}(U\1\xff" PTH_2X3 "u", 6, "without a name", NULL),
        PTH_CASE("}(U\1a" PTH_2X3 "u", 5, "a storage of 5 elements, not of 6", NULL),
        PTH_CASE("}(U\1a" PTH_TENSOR("K\1K\2K\3\x86K\3K\1\x86") "u", 6, "beyond its storage", NULL),
        PTH_CASE("}(U\1a" PTH_TENSOR("K\0K\2K\4\x86K\2K\1\x86") "u", 6, NULL, "a"),            // overlapping windows
        PTH_CASE("}(U\1a" PTH_TENSOR("K\0J\xff\xff\xff\x7f\x85K\0\x85") "u", 6, "8 times the file's size", NULL),
        PTH_CASE("}(U\1a" PTH_TENSOR("K\0K\0J\xff\xff\xff\x7f\x86K\1K\1\x86") "u", 6, NULL, "a"), // empty
        PTH_CASE("}(U\1a" PTH_STORAGE "u", 6, NULL, ""),
        PTH_CASE("K\1", 0, "neither a dictionary nor a list", NULL),
        PTH_CASE("cos\nsystem\n(U\2lstR", 0, "refers to os.system", NULL),
        PTH_CASE("(U\2lsios\nsystem\n", 0, "opcode 0x69", NULL),
        PTH_CASE("ctorch\nFloatStorage\n)R", 0, "no function", NULL),
#undef PTH_CASE
    };
    for (size_t i = 0; i < GSF__COUNT(cases); i++) {
        made m = make_pth(cases[i].pickle, cases[i].size, cases[i].storage);
        gsf_nn_weights w;
        char names[100] = "";
        const gsf_result r = gsf_nn_parse_weights(ctx, "f", m.data, m.size, &w);
        for (size_t k = 0; r == GSF_OK && k < w.tensor_count; k++)
            snprintf(names + strlen(names), sizeof names - strlen(names), "%s%s", k ? " " : "", w.tensors[k].name);
        const int ok = cases[i].names ? r == GSF_OK && strcmp(names, cases[i].names) == 0
                                      : r != GSF_OK && strstr(ctx->error, cases[i].text) != NULL;
        if (!CHECK(ok)) fprintf(stderr, "  case %zu: \"%s\", \"%s\"\n", i, names, r ? ctx->error : "");
        if (ok && i == 12) {
            const float windows[8] = {0, 1, 2, 3, 2, 3, 4, 5};
            CHECK(w.tensors[0].count == 8 && memcmp(w.tensors[0].data, windows, sizeof windows) == 0 && w.read_bytes == 32);
        }
        gsf_nn_destroy_weights(ctx, &w);
        free(m.data);
    }
    test_pth_damaged(ctx, "metricnets/pth/mixed_zip.pth");
    test_pth_damaged(ctx, "metricnets/pth/mixed_legacy.pth");
}

// ---- shards

static void write_text(gsf_context* ctx, const char* name, const char* text) {
    CHECK_OK(ctx, gsf_write_file(ctx, test_scratch(name), text, strlen(text)));
}

static void test_shards(gsf_context* ctx) {
    gsf_nn_tensor tensors[ALL];
    gsf_nn_weights w;
    make_tensors(tensors);
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("s-1.safetensors"), tensors, 4));
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("s-2.safetensors"), tensors + 4, 3));
    write_text(ctx, "s.safetensors.index.json",
               "{\"metadata\":{\"total_size\":1},\"weight_map\":{\"f32\":\"s-1.safetensors\",\"u8\":\"s-2.safetensors\","
               "\"bf16\":\"s-1.safetensors\",\"f16\":\"s-1.safetensors\",\"f64\":\"s-1.safetensors\"}}");
    char folder[1024];
    snprintf(folder, sizeof folder, "%s", test_scratch(""));
    for (int way = 0; way < 3; way++) {
        if (way == 1) folder[strlen(folder) - 1] = 0; // without its trailing slash
        const char* path = way == 2 ? test_scratch("s.safetensors.index.json") : folder;
        if (CHECK_OK(ctx, gsf_nn_load_weights(ctx, path, way == 2 ? NULL : "s", &w))) check_same(&w, tensors, 7);
        gsf_nn_destroy_weights(ctx, &w);
    }
    // a prefix that matches a single file
    if (CHECK_OK(ctx, gsf_nn_load_weights(ctx, folder, "s-2", &w))) check_same(&w, tensors + 4, 3);
    gsf_nn_destroy_weights(ctx, &w);

    static const broken indices[] = {
        {"{\"weight_map\":{\"absent\":\"s-1.safetensors\"}}", 0, GSF_ERROR_FORMAT, ":24: tensor absent is not in s-1"},
        {"{\"weight_map\":{\"f32\":\"s-1.safetensors\",\"u8\":\"s-1.safetensors\"}}", 0, GSF_ERROR_FORMAT,
         "tensor u8 is not in"},
        {"{\"weight_map\":{\"f32\":\"s-2.safetensors\",\"bf16\":\"s-1.safetensors\"}}", 0, GSF_ERROR_FORMAT,
         "tensor f32 is in s-1.safetensors, not in s-2.safetensors"},
        {"{\"weight_map\":{\"f32\":\"../s-1.safetensors\"}}", 0, GSF_ERROR_FORMAT, "tensor f32: not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"..\"}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"a/b\"}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"a\\\\b\"}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"c:x\"}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"\"}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"s-1.safetensors\\u0000\"}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":7}}", 0, GSF_ERROR_FORMAT, "not a plain file name"},
        {"{\"weight_map\":{\"f32\":\"s-3.safetensors\"}}", 0, GSF_ERROR_NOT_FOUND, "s-3.safetensors"},
        {"{\"weight_map\":{\"f32\":\"s-1.safetensors\",\"f16\":\"s-4.safetensors\"}}", 0, GSF_ERROR_FORMAT,
         "two tensors are called f32"},
        {"{\"weight_map\":[]}", 0, GSF_ERROR_FORMAT, "weight_map"},
        {"{}", 0, GSF_ERROR_FORMAT, "weight_map"},
        {"[1]", 0, GSF_ERROR_FORMAT, "weight_map"},
        {"{", 0, GSF_ERROR_FORMAT, "b.safetensors.index.json:1: expected"},
    };
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("s-4.safetensors"), tensors, 1));
    for (size_t i = 0; i < GSF__COUNT(indices); i++) {
        write_text(ctx, "b.safetensors.index.json", indices[i].header);
        const int ok = CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, folder, "b", &w), indices[i].result);
        if (ok && !CHECK(strstr(ctx->error, indices[i].text) != NULL))
            fprintf(stderr, "  %s: \"%s\" is not in \"%s\"\n", indices[i].header, indices[i].text, ctx->error);
        CHECK(w.tensors == NULL && w.files == NULL);
    }
    remove(test_scratch("b.safetensors.index.json"));
    write_text(ctx, "b.safetensors.index.json", "{\"weight_map\":{}}"); // an empty weight map opens no file
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, folder, "b", &w));
    CHECK(w.tensor_count == 0);
    gsf_nn_destroy_weights(ctx, &w);
}

static void check_opens(gsf_context* ctx, const char* folder, const gsf_nn_tensor* tensors, size_t count) {
    gsf_nn_weights w;
    if (CHECK_OK(ctx, gsf_nn_load_weights(ctx, folder, NULL, &w))) check_same(&w, tensors, count);
    gsf_nn_destroy_weights(ctx, &w);
}

static void test_folders(gsf_context* ctx) { // without a prefix
#if HAS_FOLDERS
    char folder[1024], path[1100];
    int calls = 0;
    gsf_nn_tensor tensors[ALL];
    gsf_nn_weights w;
    gsf_context hooked;
    test_context_zero(&hooked);
    hooked.io.read_fn = hooked_read;
    hooked.io.write_fn = hooked_write;
    hooked.io.user = &calls;
    hooked.logger.log_fn = keep_warning;
    CHECK_OK(&hooked, gsf_init_context(&hooked));
    make_tensors(tensors);
    snprintf(folder, sizeof folder, "%s", test_scratch("folder"));
    make_folder(folder);
    static const char* const names[] = {"model.safetensors", "other.safetensors", "other.safetensors.index.json"};
    for (size_t i = 0; i < GSF__COUNT(names); i++) {
        snprintf(path, sizeof path, "%s/%s", folder, names[i]);
        remove(path);
    }
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, folder, NULL, &w), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "no .safetensors or .pth file") != NULL);
    CHECK_RESULT(&hooked, gsf_nn_load_weights(&hooked, folder, NULL, &w), GSF_ERROR_NOT_FOUND);
    snprintf(path, sizeof path, "%s/%s", folder, names[0]);
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, 3));
    check_opens(ctx, folder, tensors, 3);
    check_opens(&hooked, folder, tensors, 3);
    CHECK_RESULT(&hooked, gsf_nn_load_weights(&hooked, folder, "absent", &w), GSF_ERROR_NOT_FOUND);
    snprintf(path, sizeof path, "%s/%s", folder, names[1]);
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, 2));
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, folder, NULL, &w), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx->error, "model.safetensors") != NULL && strstr(ctx->error, "other.safetensors") != NULL);
    snprintf(path, sizeof path, "%s/%s", folder, names[2]);
    const char* index = "{\"weight_map\":{\"f32\":\"other.safetensors\"}}";
    CHECK_OK(ctx, gsf_write_file(ctx, path, index, strlen(index)));
    check_opens(ctx, folder, tensors, 2);
    snprintf(folder, sizeof folder, "%s", test_scratch("pth_folder")); // PyTorch files only
    make_folder(folder);
    made m = make_pth("\x80\2}(U\1a" PTH_2X3 "u.", sizeof "\x80\2}(U\1a" PTH_2X3 "u." - 1, 6);
    snprintf(path, sizeof path, "%s/model.pth", folder);
    CHECK_OK(ctx, gsf_write_file(ctx, path, m.data, m.size));
    free(m.data);
    for (int way = 0; way < 4; way++) {
        gsf_context* with = way & 1 ? &hooked : ctx;
        if (CHECK_OK(with, gsf_nn_load_weights(with, folder, way & 2 ? "model" : NULL, &w))) CHECK(w.tensor_count == 1);
        gsf_nn_destroy_weights(with, &w);
    }
    CHECK_RESULT(ctx, gsf_nn_load_weights(ctx, folder, "absent", &w), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "absent.safetensors") != NULL);
    snprintf(folder, sizeof folder, "%s", test_scratch("folder"));
    snprintf(path, sizeof path, "%s/%s", folder, names[0]);
    CHECK_OK(ctx, gsf_write_file(ctx, path, "junk", 4));
    CHECK_RESULT(&hooked, gsf_nn_load_weights(&hooked, folder, NULL, &w), GSF_ERROR_FORMAT);
    CHECK(strstr(hooked.error, "model.safetensors:0: 4 bytes") != NULL);
#else
    (void)ctx;
#endif
}

// ---- memory failures

static void test_file_memory(gsf_context* plain) {
    gsf_nn_tensor tensors[ALL];
    made m = make_file("{\"a\":{\"dtype\":\"U8\",\"shape\":[3],\"data_offsets\":[0,3]}}", 3);
    make_tensors(tensors);
    write_text(plain, "m.safetensors.index.json",
               "{\"weight_map\":{\"f32\":\"s-1.safetensors\",\"u8\":\"s-2.safetensors\"}}");
    size_t zip_size;
    char* zip = test_read_file(test_golden("metricnets/pth/mixed_zip.pth"), &zip_size);
    for (int job = 0; job < 5; job++) {
        size_t k = 1;
        for (int done = 0; !done; k++) {
            gsf_context ctx;
            gsf_nn_weights w;
            counter c;
            memset(&c, 0, sizeof c);
            memset(&w, 0, sizeof w);
            test_context_zero(&ctx);
            count_memory(&ctx, &c);
            CHECK_OK(&ctx, gsf_init_context(&ctx));
            c.fail_at = k;
            const char* out = test_scratch("oom.safetensors");
            const gsf_result r = job == 0   ? gsf_nn_parse_weights(&ctx, "m", m.data, m.size, &w)
                                 : job == 1 ? gsf_nn_load_weights(&ctx, test_scratch(""), "m", &w)
                                 : job == 2 ? gsf_nn_load_weights(&ctx, test_scratch(""), "s-1", &w)
                                 : job == 4 ? gsf_nn_parse_weights(&ctx, "m", zip, zip_size, &w)
                                            : gsf_nn_save_tensors(&ctx, out, tensors, ALL);
            done = r == GSF_OK;
            CHECK_RESULT(&ctx, r, done ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY);
            CHECK(done == (c.calls < k));
            gsf_nn_destroy_weights(&ctx, &w);
            CHECK(c.live == 0);
            if (k > 1000) break;
        }
        CHECK(k > 3 && k < 200);
    }
    free(zip);
    free(m.data);
}

static void test_large_header(gsf_context* ctx) { // about 10 MB, more than any real model has
    enum { TENSORS = 100000 };
    gsf_buffer text;
    gsf_nn_weights w;
    memset(&text, 0, sizeof text);
    gsf_append_bytes(ctx, &text, "{", 1);
    for (int i = 0; i < TENSORS; i++)
        gsf_append_text(ctx, &text,
                        "%s\"transformer_blocks.%d.attn1.to_q.weight\":{\"dtype\":\"U8\",\"shape\":[1],"
                        "\"data_offsets\":[%d,%d]}",
                        i ? "," : "", i, i, i + 1);
    gsf_append_bytes(ctx, &text, "}", 1);
    CHECK(text.size > 9000000);
    made m = make_file(text.data, TENSORS);
    if (CHECK_OK(ctx, gsf_nn_parse_weights(ctx, "large", m.data, m.size, &w))) {
        CHECK(w.tensor_count == TENSORS);
        for (int i = 0; i < TENSORS; i += 999) {
            char name[80];
            float v;
            snprintf(name, sizeof name, "transformer_blocks.%d.attn1.to_q.weight", i);
            const gsf_nn_tensor* t = gsf_nn_find_tensor(&w, name);
            if (!CHECK(t != NULL)) continue;
            gsf_nn_convert_tensor(t, 0, 1, &v);
            CHECK(v == (float)(i & 255));
        }
    }
    gsf_nn_destroy_weights(ctx, &w);
    gsf_destroy_buffer(ctx, &text);
    free(m.data);
}

// ---- the golden models

static void test_golden_model(gsf_context* ctx, const char* part, const char* prefix, size_t files) {
    char folder[256], path[320];
    gsf_nn_weights w;
    snprintf(folder, sizeof folder, "restorer/model/%s", part);
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_golden(folder), prefix, &w))) return;
    CHECK(w.tensor_count > 10 && (!HAS_FOLDERS || w.mapped_bytes > 1000));
    snprintf(path, sizeof path, "%s/diffusion_pytorch_model.safetensors", folder);
    FILE* single = fopen(test_golden(path), "rb");
    if (single) { // compared with the test's own reader
        fclose(single);
        test_tensors reference = test_open_tensors(test_golden(path));
        CHECK(w.mapped_bytes + w.read_bytes == reference.size);
        for (size_t i = 0; i < w.tensor_count; i += 7) {
            const gsf_nn_tensor* t = &w.tensors[i];
            test_tensor e = test_get_tensor(&reference, t->name);
            if (CHECK(e.count == (size_t)t->count && e.rank == t->rank &&
                      strcmp(e.dtype, gsf__nn_dtype_name(t->dtype)) == 0)) {
                float* v = (float*)malloc((e.count + 1) * sizeof(float));
                gsf_nn_convert_tensor(t, 0, t->count, v);
                for (int k = 0; k < e.rank; k++) CHECK((int64_t)e.dim[k] == t->shape[k]);
                test_compare_floats(t->name, v, e.v, e.count, 0.0);
                free(v);
            }
            test_free_tensor(&e);
        }
        test_close_tensors(&reference);
    } else {
        CHECK(files == 0 || ((gsf__nn_files*)w.files)->count >= files);
    }
    gsf_nn_destroy_weights(ctx, &w);
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_golden(folder), NULL, &w)); // the prefix is detected
    gsf_nn_destroy_weights(ctx, &w);
}

// ---- the loader that the networks use

static void test_loader(gsf_context* ctx) {
    gsf_nn_tensor tensors[ALL];
    gsf_nn_weights w;
    gsf__nn_loader loader;
    const gsf_nn_tensor* t;
    const int64_t six[2] = {2, 3}, five[1] = {5}, wrong[2] = {3, 2}, any[2] = {-1, 3};
    make_tensors(tensors);
    if (!CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_scratch("all.safetensors"), NULL, &w))) return;
    CHECK_OK(ctx, gsf__nn_begin_loading(ctx, &w, &loader));
    CHECK_OK(ctx, gsf__nn_need(&loader, &t, 2, six, "f%d", 32));
    CHECK(t == gsf_nn_find_tensor(&w, "f32"));
    CHECK_OK(ctx, gsf__nn_need(&loader, &t, 2, any, "f32"));
    CHECK_OK(ctx, gsf__nn_need(&loader, &t, 1, five, "bf%d", 16));
    CHECK(t == gsf_nn_find_tensor(&w, "bf16"));
    CHECK_RESULT(ctx, gsf__nn_need(&loader, &t, 1, five, "bf%d", 17), GSF_ERROR_FORMAT);
    CHECK(t == NULL && strstr(ctx->error, "all.safetensors: tensor bf17 is missing") != NULL);
    CHECK_RESULT(ctx, gsf__nn_need(&loader, &t, 2, wrong, "f32"), GSF_ERROR_FORMAT);
    CHECK(t == NULL && strstr(ctx->error, "tensor f32 has shape [2, 3], not [3, 2]") != NULL);
    CHECK_RESULT(ctx, gsf__nn_need(&loader, &t, 1, any, "f32"), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "[2, 3], not [?]") != NULL);
    CHECK_RESULT(ctx, gsf__nn_need(&loader, &t, 0, NULL, "f64"), GSF_ERROR_UNSUPPORTED);
    CHECK(strstr(ctx->error, "tensor f64 is F64") != NULL);
    // unused: empty, f16, i.., u8 and the tensor with the odd name
    CHECK_RESULT(ctx, gsf__nn_end_loading(&loader, GSF_OK), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "8 tensors that this model does not have: empty, f16, i16, ...") != NULL);

    CHECK_OK(ctx, gsf__nn_begin_loading(ctx, &w, &loader));
    // an earlier error is passed on unchanged
    CHECK_RESULT(ctx, gsf__nn_end_loading(&loader, GSF_ERROR_NUMERIC), GSF_ERROR_NUMERIC);
    CHECK_OK(ctx, gsf__nn_begin_loading(ctx, &w, &loader));
    gsf__nn_ignore(&loader, "i");
    gsf__nn_ignore(&loader, "f");
    gsf__nn_ignore(&loader, "\xc3");
    CHECK_OK(ctx, gsf__nn_need(&loader, &t, 1, five, "bf16"));
    CHECK_RESULT(ctx, gsf__nn_end_loading(&loader, GSF_OK), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "2 tensors that this model does not have: empty, u8") != NULL && !strstr(ctx->error, "..."));
    CHECK_OK(ctx, gsf__nn_begin_loading(ctx, &w, &loader));
    gsf__nn_ignore(&loader, "");
    CHECK_OK(ctx, gsf__nn_end_loading(&loader, GSF_OK));
    gsf_nn_destroy_weights(ctx, &w);
}

static void test_config(gsf_context* ctx) {
    static const char text[] = "{\"heads\":48,\"eps\":1e-6,\"none\":null,\"half\":1.5,\"yes\":true,\"name\":\"silu\","
                               "\"dims\":[8,16]}";
    gsf__nn_config c;
    int64_t n, list[3];
    size_t count;
    double x;
    int flag;
    const char* s;
    if (!CHECK_OK(ctx, gsf__nn_parse_config(ctx, "config.json", text, sizeof text - 1, &c))) return;
    CHECK_OK(ctx, gsf__nn_config_int(&c, "heads", 1, 64, &n));
    CHECK(n == 48);
    CHECK_RESULT(ctx, gsf__nn_config_int(&c, "heads", 1, 47, &n), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "config.json:9: heads is not a whole number from 1 to 47") != NULL);
    CHECK_RESULT(ctx, gsf__nn_config_int(&c, "half", 1, 47, &n), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf__nn_config_int(&c, "name", 1, 47, &n), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf__nn_config_int(&c, "absent", 1, 47, &n), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx->error, "config.json: absent is missing") != NULL);
    CHECK_OK(ctx, gsf__nn_config_int_or(&c, "none", 7, 1, 5, &n));
    CHECK(n == 7);
    CHECK_OK(ctx, gsf__nn_config_int_or(&c, "heads", 7, 1, 64, &n));
    CHECK(n == 48);
    CHECK_RESULT(ctx, gsf__nn_config_int_or(&c, "half", 7, 1, 64, &n), GSF_ERROR_FORMAT);
    CHECK_OK(ctx, gsf__nn_config_number(&c, "eps", 0.0, 1.0, &x));
    CHECK(x == 1e-6);
    CHECK_RESULT(ctx, gsf__nn_config_number(&c, "eps", 1e-5, 1.0, &x), GSF_ERROR_FORMAT);
    CHECK_OK(ctx, gsf__nn_config_number_or(&c, "absent", 0.7, 0.0, 1.0, &x));
    CHECK(x == 0.7);
    CHECK_OK(ctx, gsf__nn_config_bool_or(&c, "yes", 0, &flag));
    CHECK(flag == 1);
    CHECK_OK(ctx, gsf__nn_config_bool_or(&c, "none", 1, &flag));
    CHECK(flag == 1);
    CHECK_RESULT(ctx, gsf__nn_config_bool_or(&c, "heads", 1, &flag), GSF_ERROR_FORMAT);
    CHECK_OK(ctx, gsf__nn_config_string(&c, "name", NULL, &s));
    CHECK(strcmp(s, "silu") == 0);
    CHECK_OK(ctx, gsf__nn_config_string(&c, "absent", "gelu", &s));
    CHECK(strcmp(s, "gelu") == 0);
    CHECK_RESULT(ctx, gsf__nn_config_string(&c, "absent", NULL, &s), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf__nn_config_string(&c, "half", NULL, &s), GSF_ERROR_FORMAT);
    CHECK_OK(ctx, gsf__nn_config_ints(&c, "dims", 1, 16, 3, list, &count));
    CHECK(count == 2 && list[0] == 8 && list[1] == 16);
    CHECK_RESULT(ctx, gsf__nn_config_ints(&c, "dims", 1, 16, 1, list, &count), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf__nn_config_ints(&c, "dims", 1, 15, 3, list, &count), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf__nn_config_ints(&c, "heads", 1, 15, 3, list, &count), GSF_ERROR_FORMAT);
    gsf__nn_close_config(&c);
    CHECK_RESULT(ctx, gsf__nn_parse_config(ctx, "config.json", "[]", 2, &c), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf__nn_open_config(ctx, test_scratch("."), "absent.json", 0, &c), GSF_ERROR_NOT_FOUND);
    // treated as an empty object
    if (CHECK_OK(ctx, gsf__nn_open_config(ctx, test_scratch("."), "absent.json", 1, &c))) {
        CHECK_OK(ctx, gsf__nn_config_int_or(&c, "heads", 7, 1, 64, &n));
        CHECK(n == 7);
        CHECK_RESULT(ctx, gsf__nn_config_int(&c, "heads", 1, 64, &n), GSF_ERROR_FORMAT);
    }
    gsf__nn_close_config(&c);
    if (CHECK_OK(ctx, gsf__nn_open_config(ctx, test_golden("restorer/model/transformer"), "config.json", 0, &c)))
        CHECK_OK(ctx, gsf__nn_config_int(&c, "num_layers", 1, 1000, &n));
    gsf__nn_close_config(&c);
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    test_round_trip(&ctx);
    test_bad_save(&ctx);
    test_values(&ctx);
    test_broken(&ctx);
    test_cut_and_flipped(&ctx);
    test_shards(&ctx);
    test_folders(&ctx);
    test_pth(&ctx);
    test_file_memory(&ctx);
    test_large_header(&ctx);
    test_golden_model(&ctx, "transformer", "diffusion_pytorch_model", 1);
    test_golden_model(&ctx, "vae", "diffusion_pytorch_model", 1);
    test_golden_model(&ctx, "text_encoder", "model", 1);
    test_loader(&ctx);
    test_config(&ctx);
    return test_report();
}
