// fuzz_pth.c - PyTorch files, zip and legacy. Build line: fuzz.h. Accepted tensors are written as safetensors and read again.
#include "gsfixer_nn.h"

#include "fuzz.h"

static uint64_t bytes_of(const gsf_nn_tensor* t) { return (uint64_t)t->count * gsf_nn_get_dtype_size(t->dtype); }

static void check_again(gsf_context* ctx, const gsf_nn_weights* w) {
    fuzz_file files[2] = {{"again", NULL, 0}, {NULL, NULL, 0}};
    gsf_nn_weights again;
    fuzz_hook_files(ctx, files);
    FUZZ_CHECK(gsf_nn_save_tensors(ctx, "again", w->tensors, w->tensor_count) == GSF_OK);
    FUZZ_CHECK(gsf_nn_parse_weights(ctx, "again", files[0].data, files[0].size, &again) == GSF_OK);
    FUZZ_CHECK(again.tensor_count == w->tensor_count);
    for (size_t i = 0; i < w->tensor_count; i++) {
        const gsf_nn_tensor *a = &w->tensors[i], *b = &again.tensors[i];
        FUZZ_CHECK(strcmp(a->name, b->name) == 0 && a->dtype == b->dtype && a->rank == b->rank);
        FUZZ_CHECK(memcmp(a->shape, b->shape, sizeof a->shape) == 0);
        FUZZ_CHECK(bytes_of(a) == 0 || memcmp(a->data, b->data, (size_t)bytes_of(a)) == 0);
    }
    gsf_nn_destroy_weights(ctx, &again);
    free((void*)(uintptr_t)files[0].data);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_nn_weights w;
    static const uint8_t none = 0;
    const gsf_result result = gsf_nn_parse_weights(&ctx, "fuzz", data ? data : &none, size, &w);
    if (result == GSF_OK) {
        fuzz_limit = SIZE_MAX / 2; // tensors may share their data: the written file can be much larger
        uint64_t total = 0;
        for (size_t i = 0; i < w.tensor_count; i++) {
            FUZZ_CHECK(i == 0 || strcmp(w.tensors[i - 1].name, w.tensors[i].name) < 0);
            FUZZ_CHECK(gsf_nn_find_tensor(&w, w.tensors[i].name) == &w.tensors[i]);
            total += bytes_of(&w.tensors[i]);
        }
        if (total < (uint64_t)1 << 24 && !gsf_nn_find_tensor(&w, "__metadata__")) check_again(&ctx, &w);
    } else {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED);
        FUZZ_CHECK(w.tensors == NULL && w.files == NULL);
        fuzz_check_error(&ctx, "fuzz:");
    }
    gsf_nn_destroy_weights(&ctx, &w);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
