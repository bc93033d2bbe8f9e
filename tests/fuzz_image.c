// Fuzz target for the image decoders behind gsf_load_image_memory.
//   clang -g -O1 -fsanitize=fuzzer,address,undefined -DGSFIXER_IMPLEMENTATION -I. tests/fuzz_image.c -o fuzz_image -lm
//   ./fuzz_image tests/corpus/image
#include "gsfixer.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    static const int32_t channels[] = {0, 1, 3, 4};
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK) abort();
    gsf_image image;
    const gsf_result result = gsf_load_image_memory(&ctx, "fuzz", data, size, channels[size % 4], &image);
    if (result == GSF_OK) {
        unsigned sum = 0; // every pixel is readable
        for (int64_t i = 0; i < image.stride_y * image.height; i++) sum += ((const uint8_t*)image.data)[i];
        if (image.width < 1 || image.height < 1 || sum == 0xffffffffu) abort();
    } else if (image.data || strncmp(ctx.error, "fuzz:", 5) != 0) {
        abort();
    }
    gsf_destroy_image(&ctx, &image);
    return 0;
}
