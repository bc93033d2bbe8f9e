// What a user of the package writes: one file with the implementation, and calls.
#define GSFIXER_IMPLEMENTATION
#include <gsfixer_splat.h>

int main(void) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK) return 1;
    gsf_splats splats;
    if (gsf_splat_make(&ctx, 3, 2, &splats) != GSF_OK) return 2;
    const int wrong = splats.count != 3 || gsf_splat_count_sh(splats.sh_degree) != 9 || splats.ids[2] != 2;
    gsf_splat_destroy(&ctx, &splats);
    return wrong ? 3 : 0;
}
