// fuzz_cameras.c - cameras.json: accepted cameras are usable and survive being saved and loaded again. Build line:
// fuzz.h.
#include "fuzz.h"

static int same(double a, double b) { return memcmp(&a, &b, sizeof a) == 0 || (a == 0.0 && b == 0.0); }

static void check_same(const gsf_camera* a, const gsf_camera* b) {
    for (int k = 0; k < 16; k++) FUZZ_CHECK(same(a->w2c[k], b->w2c[k]));
    FUZZ_CHECK(same(a->fx, b->fx) && same(a->fy, b->fy) && same(a->cx, b->cx) && same(a->cy, b->cy));
    FUZZ_CHECK(a->width == b->width && a->height == b->height);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    fuzz_file files[] = {{"fuzz", data, size}, {NULL, NULL, 0}};
    gsf_camera *cameras, *again;
    size_t count, again_count;
    fuzz_limit += 64 * size; // the saved file
    fuzz_hook_files(&ctx, files);
    const gsf_result result = gsf_load_cameras(&ctx, "fuzz", &cameras, &count);
    if (result == GSF_OK) {
        for (size_t i = 0; i < count; i++) FUZZ_CHECK(gsf_check_camera(&ctx, cameras + i) == GSF_OK);
        FUZZ_CHECK(gsf_save_cameras(&ctx, "fuzz", cameras, NULL, count) == GSF_OK);
        FUZZ_CHECK(gsf_load_cameras(&ctx, "fuzz", &again, &again_count) == GSF_OK && again_count == count);
        for (size_t i = 0; i < count; i++) check_same(cameras + i, again + i);
        gsf_free(&ctx, again);
        free((void*)(uintptr_t)files[0].data);
    } else {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT && cameras == NULL && count == 0);
        fuzz_check_error(&ctx, "fuzz:");
    }
    gsf_free(&ctx, cameras);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
