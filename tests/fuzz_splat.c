// fuzz_splat.c - .splat files: accepted splats are finite and survive being written and read again. Build line: fuzz.h.
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    gsf_splats splats, again;
    if (gsf_splat_parse(&ctx, "fuzz.splat", data, size, &splats) != GSF_OK) {
        FUZZ_CHECK(splats.owned == NULL && ctx.error[0] != 0 && fuzz_live == 0 && size % 32 != 0);
        return 0;
    }
    FUZZ_CHECK(splats.count <= size / 32 && splats.sh_degree == 0);
    for (size_t i = 0; i < 3 * splats.count; i++)
        FUZZ_CHECK(isfinite(splats.means[i]) && isfinite(splats.log_scales[i]) && isfinite(splats.sh[i]));
    for (size_t i = 0; i < splats.count; i++) FUZZ_CHECK(isfinite(splats.opacity_logits[i]));
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    FUZZ_CHECK(gsf_splat_format(&ctx, "again.splat", &splats, NULL, &text) == GSF_OK);
    FUZZ_CHECK(gsf_splat_parse(&ctx, "again.splat", text.data, text.size, &again) == GSF_OK);
    // A position of a splat far from a large origin may leave float32 when it is written in world coordinates.
    FUZZ_CHECK(again.count <= splats.count && text.size == 32 * again.count);
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &again);
    gsf_splat_destroy(&ctx, &splats);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
