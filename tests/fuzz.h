// fuzz.h - what the fuzz targets share: a context whose allocator traps when a reader asks for more memory than its
// input justifies (64 times its size and 1 MiB, all live blocks together), and checks of what a reader hands out.
// By hand: clang -g -O1 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all
//          -DGSFIXER_STATIC -DGSFIXER_IMPLEMENTATION -I. -Itests tests/fuzz_X.c -lm
//          ./a.out -max_len=8192 tests/corpus/X
#ifndef FUZZ_H
#define FUZZ_H

#include "gsfixer_splat.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FUZZ_CHECK(condition) ((condition) ? (void)0 : abort())

static size_t fuzz_live, fuzz_limit;

static void* fuzz_alloc(void* user, size_t size) {
    (void)user;
    FUZZ_CHECK(size <= fuzz_limit && fuzz_live <= fuzz_limit - size);
    size_t* block = (size_t*)malloc(size + 2 * sizeof(size_t));
    FUZZ_CHECK(block);
    block[0] = size;
    fuzz_live += size;
    return block + 2;
}
static void fuzz_free(void* user, void* memory) {
    (void)user;
    size_t* block = (size_t*)memory - 2;
    fuzz_live -= block[0];
    free(block);
}

static inline gsf_context fuzz_context(size_t input_size) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.allocator.alloc_fn = fuzz_alloc;
    ctx.allocator.free_fn = fuzz_free;
    ctx.threads = 1;
    fuzz_limit = 64 * input_size + (1 << 20);
    FUZZ_CHECK(gsf_init_context(&ctx) == GSF_OK && fuzz_live == 0);
    return ctx;
}

// A scene that was accepted must be usable: cameras checked, tracks in range and ascending, images made.
static inline void fuzz_use_scene(gsf_context* ctx, gsf_scene* scene) {
    FUZZ_CHECK(scene->view_count > 0 && isfinite(scene->origin[0] + scene->origin[1] + scene->origin[2]));
    for (size_t v = 0; v < scene->view_count; v++) {
        FUZZ_CHECK(gsf_check_camera(ctx, &scene->views[v].camera) == GSF_OK);
        FUZZ_CHECK(v == 0 || strcmp(scene->views[v - 1].name, scene->views[v].name) < 0);
    }
    FUZZ_CHECK(scene->track_begin[0] == 0);
    for (size_t p = 0; p < scene->point_count; p++)
        for (size_t e = scene->track_begin[p]; e < scene->track_begin[p + 1]; e++) {
            FUZZ_CHECK(scene->track_views[e] < scene->view_count);
            FUZZ_CHECK(e == scene->track_begin[p] || scene->track_views[e - 1] < scene->track_views[e]);
        }
    uint8_t pixels[12] = {0, 50, 100, 150, 200, 250, 10, 60, 110, 160, 210, 255};
    const gsf_image photo = gsf_wrap_image(pixels, GSF_U8, 2, 2, 3);
    const gsf_camera* first = &scene->views[0].camera;
    if ((int64_t)first->width * first->height <= 16384 && first->width < 1000 && first->height < 1000) {
        const gsf_result r = gsf_splat_set_view_image(ctx, scene, 0, &photo);
        FUZZ_CHECK(r == GSF_OK && scene->views[0].image.width == first->width);
    }
}

#endif
