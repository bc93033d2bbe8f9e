// fuzz_safetensors.c - safetensors files and the index of a sharded model. Build line: fuzz.h. The input is used twice:
//   as a file; and, split at its first zero byte, as index.json and shards: a u16 (little-endian) gives the size of the
//   first shard that is read, and the rest serves as each of the other shards. The index is opened by name and through its
//   folder. Accepted tensors are written and read again.
#include "gsfixer_nn.h"

#include "fuzz.h"

typedef struct bytes { const uint8_t* data; size_t size; } bytes;
typedef struct fuzz_files { bytes index, first, others, written; int reads; } fuzz_files;

enum { FOLDER = 16 }; // files that can be read, index.json included, under whatever names

static gsf_result read_fn(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    fuzz_files* files = (fuzz_files*)user;
    const bytes* from = files->reads == 0 ? &files->index : files->reads == 1 ? &files->first : &files->others;
    if (files->reads++ == FOLDER) return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: not there", path);
    *data = gsf_alloc(ctx, from->size, 1);
    FUZZ_CHECK(*data);
    if (from->size) memcpy(*data, from->data, from->size);
    *size = from->size;
    return GSF_OK;
}

static gsf_result write_fn(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    fuzz_files* files = (fuzz_files*)user;
    uint8_t* copy = (uint8_t*)malloc(size);
    (void)ctx, (void)path;
    FUZZ_CHECK(copy);
    memcpy(copy, data, size);
    files->written.data = copy;
    files->written.size = size;
    return GSF_OK;
}

static uint64_t bytes_of(const gsf_nn_tensor* t) { return (uint64_t)t->count * gsf_nn_get_dtype_size(t->dtype); }

// Checks that names are sorted, shapes match sizes, and data lies in [begin, end) if given. Reads every value.
static void check_tensors(const gsf_nn_weights* w, const uint8_t* begin, const uint8_t* end) {
    for (size_t i = 0; i < w->tensor_count; i++) {
        const gsf_nn_tensor* t = &w->tensors[i];
        int64_t count = 1;
        float values[64];
        FUZZ_CHECK(i == 0 || strcmp(w->tensors[i - 1].name, t->name) < 0);
        FUZZ_CHECK(gsf_nn_find_tensor(w, t->name) == t);
        for (int32_t k = 0; k < t->rank; k++) count *= t->shape[k];
        FUZZ_CHECK(count == t->count && count >= 0 && t->rank <= GSF_NN_MAX_RANK);
        const uint8_t* data = (const uint8_t*)t->data;
        FUZZ_CHECK(!begin || (data >= begin && data <= end && (uint64_t)(end - data) >= bytes_of(t)));
        for (int64_t k = 0; k < count; k += 64) gsf_nn_convert_tensor(t, k, count - k < 64 ? count - k : 64, values);
    }
}

static void check_again(gsf_context* ctx, fuzz_files* files, const gsf_nn_weights* w) {
    gsf_nn_weights again;
    FUZZ_CHECK(gsf_nn_save_tensors(ctx, "again", w->tensors, w->tensor_count) == GSF_OK);
    const bytes written = files->written;
    FUZZ_CHECK(gsf_nn_parse_weights(ctx, "again", written.data, written.size, &again) == GSF_OK);
    FUZZ_CHECK(again.tensor_count == w->tensor_count);
    for (size_t i = 0; i < w->tensor_count; i++) {
        const gsf_nn_tensor *a = &w->tensors[i], *b = &again.tensors[i];
        FUZZ_CHECK(strcmp(a->name, b->name) == 0 && a->dtype == b->dtype && a->rank == b->rank);
        FUZZ_CHECK(memcmp(a->shape, b->shape, sizeof a->shape) == 0);
        FUZZ_CHECK(memcmp(a->data, b->data, (size_t)bytes_of(a)) == 0);
    }
    gsf_nn_destroy_weights(ctx, &again);
    free((void*)(uintptr_t)written.data);
}

static void check_refused(const gsf_context* ctx, const gsf_nn_weights* w, gsf_result result) {
    FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED || result == GSF_ERROR_NOT_FOUND);
    FUZZ_CHECK(w->tensors == NULL && w->files == NULL && strchr(ctx->error, ':') != NULL);
    for (const char* c = ctx->error; *c; c++) FUZZ_CHECK((unsigned char)*c >= 0x20); // one line
}

// Opens the index and its shards by `path`. Returns the number of tensors, or the error.
static int64_t open_shards(gsf_context* ctx, fuzz_files* files, const char* path) {
    gsf_nn_weights w;
    files->reads = 0;
    const gsf_result result = gsf_nn_load_weights(ctx, path, NULL, &w);
    const int64_t count = result == GSF_OK ? (int64_t)w.tensor_count : -(int64_t)result;
    if (result == GSF_OK) check_tensors(&w, NULL, NULL);
    else check_refused(ctx, &w, result);
    if (result == GSF_OK) check_again(ctx, files, &w);
    gsf_nn_destroy_weights(ctx, &w);
    return count;
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_nn_weights w;
    fuzz_files files;
    static const uint8_t none = 0;
    memset(&files, 0, sizeof files);
    ctx.io.read_fn = read_fn;
    ctx.io.write_fn = write_fn;
    ctx.io.user = &files;
    if (!data) data = &none;
    gsf_result result = gsf_nn_parse_weights(&ctx, "fuzz", data, size, &w);
    if (result == GSF_OK) {
        check_tensors(&w, data, data + size);
        check_again(&ctx, &files, &w);
    } else {
        check_refused(&ctx, &w, result);
        FUZZ_CHECK(result != GSF_ERROR_NOT_FOUND && strncmp(ctx.error, "fuzz:", 5) == 0);
    }
    gsf_nn_destroy_weights(&ctx, &w);

    const uint8_t* zero = size > 2 ? (const uint8_t*)memchr(data, 0, size - 2) : NULL;
    if (zero) {
        const size_t head = (size_t)(zero - data), rest = size - head - 3, wanted = zero[1] + (size_t)zero[2] * 256;
        files.index.data = data;
        files.index.size = head;
        files.first.data = zero + 3;
        files.first.size = wanted < rest ? wanted : rest;
        files.others.data = files.first.data + files.first.size;
        files.others.size = rest - files.first.size;
        fuzz_limit = 64 * head + (64 + 6 * FOLDER) * rest + ((size_t)1 << 20);
        const int64_t by_name = open_shards(&ctx, &files, "fuzz.index.json");
        FUZZ_CHECK(open_shards(&ctx, &files, "fuzz") == by_name);
    }
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
