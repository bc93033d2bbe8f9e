// fuzz_colmap_bin.c - the three binary files of a COLMAP model. Build line: fuzz.h. Input: u32 size of cameras.bin, u32
// size of images.bin (little-endian, clamped to the input), then the concatenated files.
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_bytes files[3];
    gsf_scene scene;
    if (size < 8) return 0;
    size_t at = 8;
    memset(files, 0, sizeof files);
    for (int i = 0; i < 3; i++) {
        size_t wanted = SIZE_MAX;
        if (i < 2) {
            const uint8_t* p = data + 4 * i;
            wanted = (size_t)p[0] | (size_t)p[1] << 8 | (size_t)p[2] << 16 | (size_t)p[3] << 24;
        }
        files[i].data = data + at;
        files[i].size = wanted < size - at ? wanted : size - at;
        at += files[i].size;
    }
    const gsf_result r = gsf_splat_parse_colmap(&ctx, 0, &files[0], &files[1], &files[2], &scene);
    if (r == GSF_OK) fuzz_use_scene(&ctx, &scene);
    else FUZZ_CHECK(scene.state == NULL && ctx.error[0] != 0);
    gsf_splat_destroy_scene(&ctx, &scene);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
