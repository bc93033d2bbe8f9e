// Fuzz target for the image decoders: gsf_decode_image, and gsf_query_image, which parses headers separately and must
// report the size that is decoded.
//   clang -g -O1 -fsanitize=fuzzer,address,undefined -DGSFIXER_IMPLEMENTATION -I. tests/fuzz_image.c -o fuzz_image -lm
//   ./fuzz_image tests/corpus/image
#include "gsfixer.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

typedef struct input { const uint8_t* data; size_t size; } input;

static gsf_result read_input(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    const input* in = (const input*)user;
    (void)path;
    if (!(*data = gsf_alloc(ctx, in->size + 1, 1))) return GSF_ERROR_OUT_OF_MEMORY;
    if (in->size) memcpy(*data, in->data, in->size);
    *size = in->size;
    return GSF_OK;
}

static gsf_result write_nothing(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user, (void)path, (void)data, (void)size;
    return gsf_fail(ctx, GSF_ERROR_IO, "fuzz: nothing is written");
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    static const int32_t channels[] = {0, 1, 3, 4};
    input in = {data, size};
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.io.read_fn = read_input;
    ctx.io.write_fn = write_nothing;
    ctx.io.user = &in;
    if (gsf_init_context(&ctx) != GSF_OK) abort();
    gsf_image image;
    int64_t width = 0, height = 0;
    int32_t file_channels = 0;
    const gsf_result query = gsf_query_image(&ctx, "fuzz", &width, &height, &file_channels);
    if (query != GSF_OK && strncmp(ctx.error, "fuzz:", 5) != 0) abort();
    const gsf_result result = gsf_decode_image(&ctx, "fuzz", data, size, channels[size % 4], &image);
    if (result == GSF_OK) {
        unsigned sum = 0; // reads every pixel
        for (int64_t i = 0; i < image.stride_y * image.height; i++) sum += ((const uint8_t*)image.data)[i];
        if (image.width < 1 || image.height < 1 || sum == 0xffffffffu) abort();
        if (query != GSF_OK || image.width != width || image.height != height) abort();
        if (size % 4 == 0 && image.channels != file_channels) abort();
    } else if (image.data || strncmp(ctx.error, "fuzz:", 5) != 0) {
        abort();
    }
    gsf_destroy_image(&ctx, &image);
    return 0;
}
