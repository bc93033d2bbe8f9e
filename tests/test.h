// test.h - shared by the test programs: checks that survive NDEBUG, seeded random numbers, golden tensors.
// A test program calls CHECK..., ends with `return test_report();` and exits non-zero if any check failed.
#ifndef TEST_H
#define TEST_H

#include <dirent.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { TEST_SKIPPED = 77 }; // exit code that CTest reports as skipped

static int test_checks, test_failures;

#define CHECK(condition) test_check((condition) != 0, #condition, __FILE__, __LINE__)
// Expects the gsf_result `code` from `call`; prints ctx->error otherwise.
#define CHECK_RESULT(ctx, call, code) test_check_result((ctx), (int)(call), (int)(code), #call, __FILE__, __LINE__)
#define CHECK_OK(ctx, call) CHECK_RESULT(ctx, call, GSF_OK)
#define CHECK_NEAR(actual, expected, tolerance) \
    test_check_near((double)(actual), (double)(expected), (double)(tolerance), #actual, __FILE__, __LINE__)

static inline int test_check(int ok, const char* what, const char* file, int line) {
    test_checks++;
    if (!ok && ++test_failures <= 50) fprintf(stderr, "%s:%d: failed: %s\n", file, line, what);
    return ok;
}

static inline int test_check_near(double actual, double expected, double tolerance, const char* what, const char* file,
                                  int line) {
    const int ok = actual == expected || fabs(actual - expected) <= tolerance;
    test_checks++;
    if (!ok && ++test_failures <= 50)
        fprintf(stderr, "%s:%d: %s = %.17g, expected %.17g within %g\n", file, line, what, actual, expected, tolerance);
    return ok;
}

#ifdef GSF_BASE_INCLUDED
static inline int test_check_result(gsf_context* ctx, int actual, int expected, const char* what, const char* file,
                                    int line) {
    test_checks++;
    if (actual != expected && ++test_failures <= 50)
        fprintf(stderr, "%s:%d: %s returned %s, expected %s (%s)\n", file, line, what,
                gsf_describe_result((gsf_result)actual), gsf_describe_result((gsf_result)expected), ctx->error);
    return actual == expected;
}

// Zeroes and initialises a context of the machine's highest level, which AUTO may pass over; the environment variable
// GSF_TEST_CPU=scalar|avx2|... forces another one. To install hooks, call test_context_zero, fill them in and call
// gsf_init_context.
static inline void test_context_zero(gsf_context* ctx) {
    memset(ctx, 0, sizeof *ctx);
    const char* level = getenv("GSF_TEST_CPU");
    for (int known = GSF_CPU_SCALAR; level && known <= GSF_CPU_SIMD128; known++)
        if (strcmp(level, gsf_describe_cpu_level((gsf_cpu_level)known)) == 0) ctx->cpu_level = (gsf_cpu_level)known;
}
static inline void test_context_init(gsf_context* ctx) {
    test_context_zero(ctx);
#if GSF__X86
    if (ctx->cpu_level == GSF_CPU_AUTO) ctx->cpu_level = GSF_CPU_AMX;
#endif
    if (gsf_init_context(ctx) != GSF_OK) { fprintf(stderr, "gsf_init_context: %s\n", ctx->error); exit(2); }
}
#endif

// Where a test is repeated with the scalar kernels or under a sanitizer (GSF_TEST_FEW is set), `few` samples do.
static inline int test_few(int all, int few) { return getenv("GSF_TEST_FEW") ? few : all; }

static inline int test_report(void) {
    printf("%d checks, %d failed\n", test_checks, test_failures);
    return test_failures ? 1 : 0;
}

// ---- seeded numbers ------------------------------------------------------------

static inline uint64_t test_random_bits(uint64_t* state) { // splitmix64
    uint64_t x = *state += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}
static inline double test_random(uint64_t* state) {
    return (double)(test_random_bits(state) >> 11) / 9007199254740992.0;
}
static inline double test_random_in(uint64_t* state, double lo, double hi) {
    return lo + (hi - lo) * test_random(state);
}

// L2 norm of the difference over that of `expected`.
static inline double test_relative_error(const float* actual, const float* expected, size_t count) {
    double difference = 0.0, norm = 0.0;
    for (size_t i = 0; i < count; i++) {
        const double d = (double)actual[i] - (double)expected[i];
        difference += d * d;
        norm += (double)expected[i] * (double)expected[i];
    }
    return sqrt(difference / norm);
}

// ---- golden data ---------------------------------------------------------------

// Path of a file below GSF_GOLDEN (environment, default: the committed copy, compiled in as TEST_GOLDEN). Static
// buffers, the last 8 stay valid.
static inline const char* test_golden(const char* relative) {
    static char paths[8][1024];
    static int turn;
    const char* root = getenv("GSF_GOLDEN");
#ifdef TEST_GOLDEN
    if (!root || !*root) root = TEST_GOLDEN;
#endif
    if (!root || !*root) root = "tests/golden";
    char* path = paths[turn++ & 7];
    snprintf(path, sizeof paths[0], "%s/%s", root, relative);
    return path;
}

// Names, without the ending, of the files `prefix`NAME`ending` in a golden folder, in order; there has to be one.
enum { TEST_NAMES = 64, TEST_NAME_SIZE = 64 };
typedef struct test_names { size_t count; char name[TEST_NAMES][TEST_NAME_SIZE]; } test_names;

static inline int test_compare_names(const void* a, const void* b) { return strcmp((const char*)a, (const char*)b); }

static inline test_names test_list_golden(const char* folder, const char* prefix, const char* ending) {
    test_names names;
    names.count = 0;
    const size_t before = strlen(prefix), after = strlen(ending);
    DIR* list = opendir(test_golden(folder));
    for (const struct dirent* entry; list && (entry = readdir(list)) != NULL;) {
        const size_t length = strlen(entry->d_name);
        if (length <= before + after || length - after >= TEST_NAME_SIZE || names.count == TEST_NAMES) continue;
        if (strncmp(entry->d_name, prefix, before) != 0 || strcmp(entry->d_name + length - after, ending) != 0) continue;
        char* name = names.name[names.count++];
        memcpy(name, entry->d_name, length - after);
        name[length - after] = 0;
    }
    if (list) closedir(list);
    qsort(names.name, names.count, TEST_NAME_SIZE, test_compare_names);
    if (!names.count) {
        fprintf(stderr, "%s: no %s*%s\n", test_golden(folder), prefix, ending);
        exit(2);
    }
    return names;
}

// A program that holds several tests runs the one by whose name it is called: without folder and ending.
static char test_called[64];
static inline const char* test_name(const char* program) {
    for (const char* c = program; *c; c++)
        if (*c == '/' || *c == '\\') program = c + 1;
    snprintf(test_called, sizeof test_called, "%.*s", (int)strcspn(program, "."), program);
    return test_called;
}

// Path of a scratch file of this test (its own folder in the build tree); static buffers as above.
static inline const char* test_scratch(const char* name) {
    static char paths[8][1024];
    static int turn;
#ifdef TEST_TMP
    const char* root = TEST_TMP;
#else
    const char* root = getenv("TMPDIR");
    if (!root || !*root) root = "/tmp";
#endif
    char* path = paths[turn++ & 7];
    snprintf(path, sizeof paths[0], "%s/%s%s%s", root, test_called, test_called[0] ? "/" : "", name);
    return path;
}

// Folder of the real photos (environment GSF_FOX, default data/fox in the shared folder beside the checkout), or NULL.
// Without them a test prints a message and returns TEST_SKIPPED, or uses a synthetic scene.
static inline const char* test_fox(void) {
    const char* root = getenv("GSF_FOX");
    if (root && *root) return root;
#ifdef TEST_SHARED
    static char path[1024];
    snprintf(path, sizeof path, "%s/data/fox/split.json", TEST_SHARED);
    FILE* file = fopen(path, "rb");
    if (file) {
        fclose(file);
        snprintf(path, sizeof path, "%s/data/fox", TEST_SHARED);
        return path;
    }
#endif
    return NULL;
}

static inline char* test_read_file(const char* path, size_t* size) { // exits when absent
    FILE* file = fopen(path, "rb");
    if (!file) { fprintf(stderr, "%s: cannot be opened\n", path); exit(2); }
    fseek(file, 0, SEEK_END);
    const long end = ftell(file);
    rewind(file);
    char* data = (char*)malloc((size_t)end + 1);
    if (!data || fread(data, 1, (size_t)end, file) != (size_t)end) {
        fprintf(stderr, "%s: cannot be read\n", path);
        exit(2);
    }
    fclose(file);
    data[end] = 0;
    if (size) *size = (size_t)end;
    return data;
}

typedef struct test_tensors { char* data; size_t size; char path[2048]; } test_tensors; // a safetensors file

typedef struct test_tensor { // values widened to double; NULL when absent
    double* v;
    size_t count;
    int rank;
    size_t dim[8];
    char dtype[8];
    char name[128];
} test_tensor;

static inline test_tensors test_open_tensors(const char* path) {
    test_tensors t;
    t.data = test_read_file(path, &t.size);
    snprintf(t.path, sizeof t.path, "%s", path);
    return t;
}
static inline void test_close_tensors(test_tensors* t) { free(t->data); t->data = NULL; }

static inline const char* test_tensor_entry(const test_tensors* t, const char* name, const char** end) {
    uint64_t header;
    memcpy(&header, t->data, 8);
    char key[160];
    snprintf(key, sizeof key, "\"%s\":", name);
    const char* start = t->data + 8;
    for (const char* p = start; p + strlen(key) < start + header; p++)
        if (memcmp(p, key, strlen(key)) == 0 && (p[-1] == '{' || p[-1] == ',' || p[-1] == ' ')) {
            *end = start + header;
            return p + strlen(key);
        }
    return NULL;
}

// Text of a __metadata__ entry, or NULL; static buffer.
static inline const char* test_metadata(const test_tensors* t, const char* name) {
    static char value[4096];
    const char *end, *p = test_tensor_entry(t, name, &end);
    if (!p) return NULL;
    while (p < end && *p != '"') p++;
    size_t n = 0;
    for (p++; p < end && *p != '"' && n + 1 < sizeof value; p++) value[n++] = *p;
    value[n] = 0;
    return value;
}

static inline double test_half(uint16_t h) {
    const int e = h >> 10 & 31, m = h & 1023;
    const double v = e == 0 ? ldexp(m, -24) : e == 31 ? (m ? NAN : INFINITY) : ldexp(1024 + m, e - 25);
    return h & 0x8000 ? -v : v;
}

static inline test_tensor test_find_tensor(const test_tensors* t, const char* name) {
    test_tensor out;
    memset(&out, 0, sizeof out);
    snprintf(out.name, sizeof out.name, "%s", name);
    const char *end, *p = test_tensor_entry(t, name, &end);
    if (!p) return out;
    uint64_t header;
    memcpy(&header, t->data, 8);
    const char* dtype = strstr(p, "\"dtype\"");
    const char* shape = strstr(p, "\"shape\"");
    const char* offsets = strstr(p, "\"data_offsets\"");
    sscanf(strchr(dtype + 7, '"') + 1, "%7[A-Z0-9a-z_]", out.dtype);
    out.count = 1;
    for (const char* q = strchr(shape, '[') + 1; *q != ']';) {
        char* next;
        const unsigned long long d = strtoull(q, &next, 10);
        if (next == q) { q++; continue; }
        out.dim[out.rank++] = (size_t)d;
        out.count *= (size_t)d;
        q = next;
    }
    const char* base = t->data + 8 + header + strtoull(strchr(offsets, '[') + 1, NULL, 10);
    out.v = (double*)malloc((out.count ? out.count : 1) * sizeof(double));
    for (size_t i = 0; i < out.count; i++) {
#define TEST_WIDEN(tag, type) \
    if (strcmp(out.dtype, tag) == 0) { type x; memcpy(&x, base + i * sizeof x, sizeof x); out.v[i] = (double)x; }
        TEST_WIDEN("F64", double)
        TEST_WIDEN("F32", float)
        TEST_WIDEN("I64", int64_t)
        TEST_WIDEN("I32", int32_t)
        TEST_WIDEN("I16", int16_t)
        TEST_WIDEN("U8", uint8_t)
        TEST_WIDEN("I8", int8_t)
        TEST_WIDEN("BOOL", uint8_t)
#undef TEST_WIDEN
        if (strcmp(out.dtype, "F16") == 0) { uint16_t h; memcpy(&h, base + i * 2, 2); out.v[i] = test_half(h); }
        if (strcmp(out.dtype, "BF16") == 0) {
            uint16_t h; memcpy(&h, base + i * 2, 2);
            const uint32_t w = (uint32_t)h << 16; float f; memcpy(&f, &w, 4); out.v[i] = f;
        }
    }
    return out;
}

// As above, but the tensor must exist: exits with a message otherwise.
static inline test_tensor test_get_tensor(const test_tensors* t, const char* name) {
    test_tensor out = test_find_tensor(t, name);
    if (!out.v) { fprintf(stderr, "%s: no tensor %s\n", t->path, name); exit(2); }
    return out;
}
static inline void test_free_tensor(test_tensor* t) { free(t->v); t->v = NULL; }

static inline float* test_tensor_floats(const test_tensor* t) { // malloc'd float copy
    float* f = (float*)malloc((t->count ? t->count : 1) * sizeof(float));
    for (size_t i = 0; i < t->count; i++) f[i] = (float)t->v[i];
    return f;
}

// One check of max |actual - expected| <= tolerance over `count` values; prints the worst index.
static inline int test_compare(const char* what, const double* actual, const double* expected, size_t count,
                               double tolerance) {
    size_t worst = 0;
    double error = -1.0;
    for (size_t i = 0; i < count; i++) {
        double e = fabs(actual[i] - expected[i]);
        if (actual[i] == expected[i]) e = 0.0;
        if (!(e <= error)) { error = e; worst = i; } // NaN wins
        if (error != error) break;
    }
    const int ok = count == 0 || error <= tolerance;
    test_checks++;
    if (!ok && ++test_failures <= 50)
        fprintf(stderr, "%s: worst at %zu of %zu: %.17g, expected %.17g (error %.3g, allowed %.3g)\n", what, worst,
                count, actual[worst], expected[worst], error, tolerance);
    return ok;
}

// For the tables of bench/results.py: a line about an error of a measure, appended to the file that GSF_TEST_ERRORS names.
static inline void test_note_error(const char* of, double error) {
    const char* path = getenv("GSF_TEST_ERRORS");
    FILE* file = path ? fopen(path, "a") : NULL;
    if (file) fprintf(file, "{\"error_of\": \"%s\", \"error\": %.3g}\n", of, error);
    if (file) fclose(file);
}

static inline int test_compare_floats(const char* what, const float* actual, const double* expected, size_t count,
                                      double tolerance) {
    double* wide = (double*)malloc((count ? count : 1) * sizeof(double));
    for (size_t i = 0; i < count; i++) wide[i] = (double)actual[i];
    const int ok = test_compare(what, wide, expected, count, tolerance);
    free(wide);
    return ok;
}

static inline double test_max_abs(const double* v, size_t count) {
    double m = 0.0;
    for (size_t i = 0; i < count; i++) if (fabs(v[i]) > m) m = fabs(v[i]);
    return m;
}

#endif
