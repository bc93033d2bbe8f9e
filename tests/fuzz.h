// fuzz.h - shared by the fuzz targets: a context whose allocator traps if a reader allocates more memory than its input
// justifies (64 times its size plus 1 MiB, summed over all live blocks), and checks of what a reader returns. For
// formats in which few bytes may legitimately expand to many, fuzz_room sets a limit above which allocations fail: the
// reader must return GSF_ERROR_OUT_OF_MEMORY, and no input takes long. tests/fuzz.sh builds and runs all targets. By
// hand: clang -g -O1 -fsanitize=fuzzer,address,undefined -fno-sanitize-recover=all
//          -DGSFIXER_STATIC -DGSFIXER_IMPLEMENTATION -I. -Itests tests/fuzz_X.c -lm
//          ./a.out -max_len=8192 tests/corpus/X
#ifndef FUZZ_H
#define FUZZ_H

#include "gsfixer_splat.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FUZZ_CHECK(condition) ((condition) ? (void)0 : abort())

static size_t fuzz_live, fuzz_limit, fuzz_room;

static void* fuzz_alloc(void* user, size_t size) {
    (void)user;
    FUZZ_CHECK(size <= fuzz_limit && fuzz_live <= fuzz_limit - size);
    if (fuzz_live + size > fuzz_room) return NULL;
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
    fuzz_room = SIZE_MAX;
    FUZZ_CHECK(gsf_init_context(&ctx) == GSF_OK && fuzz_live == 0);
    return ctx;
}

static inline uint64_t fuzz_number(const uint8_t* p, int bytes) { // little-endian
    uint64_t value = 0;
    for (int i = bytes; i-- > 0;) value = value << 8 | p[i];
    return value;
}

// A checkpoint with corrected checksums, which mutations would never match: the chunks in `data`, then the rest
// unchanged.
static inline void fuzz_sum_chunks(gsf_context* ctx, const uint8_t* data, size_t size, gsf_buffer* out) {
    size_t at = 12;
    while (at <= size && size - at >= 16) {
        const uint64_t bytes = fuzz_number(data + at + 4, 8);
        if (bytes > size - at - 16) break;
        gsf_append_chunk(ctx, out, (const char*)data + at, data + at + 12, (size_t)bytes);
        at += 16 + (size_t)bytes;
    }
    if (at < size) gsf_append_bytes(ctx, out, (const char*)data + at, size - at);
    FUZZ_CHECK(!out->failed);
}

// Applies patches to one chunk: u8 index of the chunk, u8 kind (0 overwrite, 1 truncate, 2 append, 3 change the tag, 4
// drop or duplicate), u16 offset (little-endian), u8 size and that many bytes.
static inline void fuzz_patch_chunk(gsf_context* ctx, const uint8_t* chunk, size_t bytes, unsigned index, const uint8_t* p,
                                    size_t size, gsf_buffer* out) {
    gsf_buffer body;
    char tag[4];
    size_t repeat = 1;
    memset(&body, 0, sizeof body);
    memcpy(tag, chunk, 4);
    gsf_append_bytes(ctx, &body, (const char*)chunk + 12, bytes);
    for (size_t at = 0, n; size - at >= 5; at += 5 + n) {
        const size_t where = (size_t)fuzz_number(p + at + 2, 2);
        const char* data = (const char*)p + at + 5;
        const int kind = p[at + 1] % 5;
        n = p[at + 4] < size - at - 5 ? p[at + 4] : size - at - 5;
        if (p[at] != index) continue;
        if (kind == 0 && where < body.size) memcpy(body.data + where, data, n < body.size - where ? n : body.size - where);
        if (kind == 1 && where < body.size) body.size = where;
        if (kind == 2) gsf_append_bytes(ctx, &body, data, n);
        if (kind == 3 && n >= 4) memcpy(tag, data, 4);
        if (kind == 4) repeat = where % 3;
    }
    while (repeat-- > 0) gsf_append_chunk(ctx, out, tag, body.size ? body.data : "", body.size);
    gsf_destroy_buffer(ctx, &body);
}

// A checkpoint with the patches that `p` holds.
static inline void fuzz_patch_chunks(gsf_context* ctx, const uint8_t* file, size_t file_size, const uint8_t* p, size_t size,
                                     gsf_buffer* out) {
    unsigned index = 0;
    for (size_t at = 12; at < file_size; index++) {
        const size_t bytes = (size_t)fuzz_number(file + at + 4, 8);
        fuzz_patch_chunk(ctx, file + at, bytes, index, p, size, out);
        at += 16 + bytes;
    }
    FUZZ_CHECK(!out->failed);
}

static inline void fuzz_check_error(const gsf_context* ctx, const char* name) { // one line that names the file
    FUZZ_CHECK(strncmp(ctx->error, name, strlen(name)) == 0);
    for (const char* c = ctx->error; *c; c++) FUZZ_CHECK((unsigned char)*c >= 0x20);
}

// File hooks for targets whose reader opens files by name: `user` is a list of files, terminated by a NULL name; a file
// is found by the end of the path. Written data become the first file, in memory that the target frees.
typedef struct fuzz_file { const char* name; const void* data; size_t size; } fuzz_file;

static inline gsf_result fuzz_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    const size_t length = strlen(path);
    for (const fuzz_file* file = (const fuzz_file*)user; file->name; file++) {
        const size_t end = strlen(file->name);
        if (end > length || strcmp(path + length - end, file->name) != 0) continue;
        *data = gsf_alloc(ctx, file->size + 1, 1);
        if (!*data) return GSF_ERROR_OUT_OF_MEMORY;
        if (file->size) memcpy(*data, file->data, file->size);
        ((char*)*data)[file->size] = 0;
        *size = file->size;
        return GSF_OK;
    }
    return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: not there", path);
}
static inline gsf_result fuzz_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    fuzz_file* file = (fuzz_file*)user;
    void* copy = malloc(size ? size : 1);
    (void)ctx, (void)path;
    FUZZ_CHECK(copy);
    if (size) memcpy(copy, data, size);
    file->data = copy;
    file->size = size;
    return GSF_OK;
}
static inline void fuzz_hook_files(gsf_context* ctx, fuzz_file* files) {
    ctx->io.read_fn = fuzz_read;
    ctx->io.write_fn = fuzz_write;
    ctx->io.user = files;
}

// An accepted scene must be usable: valid cameras, tracks in range and ascending, images allocated.
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
