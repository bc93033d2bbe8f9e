// fuzz_transforms.c - transforms.json. Build line: fuzz.h.
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_bytes json;
    gsf_scene scene;
    json.data = data;
    json.size = size;
    json.name = NULL;
    const gsf_result r = gsf_splat_parse_transforms(&ctx, &json, &scene);
    if (r == GSF_OK) fuzz_use_scene(&ctx, &scene);
    else FUZZ_CHECK(scene.state == NULL && ctx.error[0] != 0);
    gsf_splat_destroy_scene(&ctx, &scene);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
