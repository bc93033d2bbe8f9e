// fuzz_glb.c - binary glTF. Build line: fuzz.h, without -DGSFIXER_IMPLEMENTATION. The input is used twice: as a file, and as
//   JSON and arrays with a zero byte between them, around which a file is put whose lengths are right. Accepted splats are
//   finite and survive being written and read again. Nodes may show the same splats many times, so allocations beyond a MiB
//   fail.
#define GSFIXER_IMPLEMENTATION
#include "fuzz.h"

static void parse(gsf_context* ctx, const uint8_t* data, size_t size) {
    gsf_splats splats, again;
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    const gsf_result result = gsf_splat_parse(ctx, "fuzz.glb", data, size, &splats);
    if (result != GSF_OK) {
        if (result != GSF_ERROR_OUT_OF_MEMORY) fuzz_check_error(ctx, "fuzz.glb:");
        FUZZ_CHECK(splats.owned == NULL);
        return;
    }
    const size_t sh = 3 * (size_t)gsf_splat_count_sh(splats.sh_degree);
    FUZZ_CHECK(splats.count <= size);
    for (size_t i = 0; i < 3 * splats.count; i++)
        FUZZ_CHECK(isfinite(splats.means[i]) && isfinite(splats.log_scales[i]));
    for (size_t i = 0; i < 4 * splats.count; i++) FUZZ_CHECK(isfinite(splats.quats[i]));
    for (size_t i = 0; i < splats.count; i++) FUZZ_CHECK(isfinite(splats.opacity_logits[i]));
    for (size_t i = 0; i < sh * splats.count; i++) FUZZ_CHECK(isfinite(splats.sh[i]));
    const gsf_result written = gsf_splat_format(ctx, "again.glb", &splats, NULL, &text);
    FUZZ_CHECK(written == GSF_OK || written == GSF_ERROR_DEGENERATE || written == GSF_ERROR_OUT_OF_MEMORY);
    const gsf_result read = written == GSF_OK ? gsf_splat_parse(ctx, "again.glb", text.data, text.size, &again) : written;
    FUZZ_CHECK(written != GSF_OK || read == GSF_OK || read == GSF_ERROR_OUT_OF_MEMORY);
    if (read == GSF_OK) {
        FUZZ_CHECK(again.count <= splats.count && again.sh_degree == splats.sh_degree);
        gsf_splat_destroy(ctx, &again);
    }
    gsf_destroy_buffer(ctx, &text);
    gsf_splat_destroy(ctx, &splats);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    fuzz_limit = SIZE_MAX;
    fuzz_room = 1 << 20;
    parse(&ctx, data, size);
    const uint8_t* zero = (const uint8_t*)memchr(data, 0, size);
    if (zero) {
        const size_t json = (size_t)(zero - data), arrays = size - json - 1, padded = (json + 3) / 4 * 4;
        uint8_t* file = (uint8_t*)malloc(28 + padded + arrays);
        if (!file) return 0;
        memcpy(file, "glTF\2\0\0\0", 8);
        gsf__store_le(file + 8, 28 + padded + arrays, 4);
        gsf__store_le(file + 12, padded, 4);
        memcpy(file + 16, "JSON", 4);
        memset(file + 20, ' ', padded);
        memcpy(file + 20, data, json);
        gsf__store_le(file + 20 + padded, arrays, 4);
        memcpy(file + 24 + padded, "BIN", 4);
        memcpy(file + 28 + padded, zero + 1, arrays);
        parse(&ctx, file, 28 + padded + arrays);
        free(file);
    }
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
