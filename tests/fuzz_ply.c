// fuzz_ply.c - PLY splat files: accepted splats are finite and survive being written and read again. Build line:
// fuzz.h.
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_splats splats, again;
    if (gsf_splat_parse(&ctx, "fuzz.ply", data, size, &splats) != GSF_OK) {
        FUZZ_CHECK(splats.owned == NULL && ctx.error[0] != 0 && fuzz_live == 0);
        return 0;
    }
    for (size_t i = 0; i < 3 * splats.count; i++) FUZZ_CHECK(isfinite(splats.means[i]));
    for (size_t i = 0; i < splats.count; i++) FUZZ_CHECK(isfinite(splats.opacity_logits[i]));
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    FUZZ_CHECK(gsf_splat_format(&ctx, "x.ply", &splats, NULL, &text) == GSF_OK);
    // A position of a splat far from a large origin may leave float32 when it is written in world coordinates.
    FUZZ_CHECK(gsf_splat_parse(&ctx, "again.ply", text.data, text.size, &again) == GSF_OK);
    FUZZ_CHECK(again.count <= splats.count && again.sh_degree == splats.sh_degree);
    for (int c = 0; c < 3; c++) FUZZ_CHECK(again.background[c] == splats.background[c]);
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &again);
    gsf_splat_destroy(&ctx, &splats);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
