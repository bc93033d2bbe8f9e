// fuzz_npy.c - gsfix's .npy depth files: accepted files survive being saved and loaded with the same values. Build
// line: fuzz.h, with examples/gsfix*.c.
#include "../examples/gsfix.h"

#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    fuzz_file files[] = {{"fuzz", data, size}, {NULL, NULL, 0}};
    gsf_image image, again;
    fuzz_hook_files(&ctx, files);
    const gsf_result result = gsfix_load_npy(&ctx, "fuzz", &image);
    if (result == GSF_OK) {
        const size_t bytes = (size_t)image.width * (size_t)image.height * sizeof(float);
        FUZZ_CHECK(image.channels == 1 && image.dtype == GSF_F32 && bytes > 0 && bytes <= size);
        FUZZ_CHECK(gsfix_save_npy(&ctx, "fuzz", &image) == GSF_OK);
        FUZZ_CHECK(gsfix_load_npy(&ctx, "fuzz", &again) == GSF_OK);
        FUZZ_CHECK(again.width == image.width && again.height == image.height);
        FUZZ_CHECK(memcmp(again.data, image.data, bytes) == 0);
        gsf_destroy_image(&ctx, &again);
        free((void*)(uintptr_t)files[0].data);
    } else {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT && image.data == NULL);
        fuzz_check_error(&ctx, "fuzz:");
    }
    gsf_destroy_image(&ctx, &image);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
