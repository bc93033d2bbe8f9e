// fuzz_colmap_txt.c - the three text files of a COLMAP model, separated by form feeds. Build line: fuzz.h.
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_bytes files[3];
    gsf_scene scene;
    size_t at = 0;
    memset(files, 0, sizeof files);
    for (int i = 0; i < 3 && at < size; i++) {
        const uint8_t* stop = i < 2 ? (const uint8_t*)memchr(data + at, '\f', size - at) : NULL;
        files[i].data = data + at;
        files[i].size = stop ? (size_t)(stop - data) - at : size - at;
        at += files[i].size + (stop != NULL);
    }
    const gsf_result r = gsf_splat_parse_colmap(&ctx, 1, &files[0], &files[1], &files[2], &scene);
    if (r == GSF_OK) fuzz_use_scene(&ctx, &scene);
    else FUZZ_CHECK(scene.state == NULL && ctx.error[0] != 0);
    gsf_splat_destroy_scene(&ctx, &scene);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
