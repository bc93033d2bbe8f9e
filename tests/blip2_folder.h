// blip2_folder.h - the captioner's golden folder with some of its files replaced, through the io hook.
#ifndef BLIP2_FOLDER_H
#define BLIP2_FOLDER_H

#include "test.h"

typedef struct blip2_file { const char *name, *text; size_t size; } blip2_file; // size 0: a string; text NULL: absent

typedef struct blip2_folder {
    gsf_context plain; // reads the files that are not replaced
    blip2_file files[6];
    size_t count;
} blip2_folder;

static gsf_result blip2_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    blip2_folder* f = (blip2_folder*)user;
    const char* name = strrchr(path, '/') + 1;
    for (size_t i = 0; i < f->count; i++) {
        if (strcmp(f->files[i].name, name) != 0) continue;
        if (!f->files[i].text) return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: not there", path);
        *size = f->files[i].size ? f->files[i].size : strlen(f->files[i].text);
        *data = gsf_alloc(ctx, *size, 1);
        if (!*data) return GSF_ERROR_OUT_OF_MEMORY;
        memcpy(*data, f->files[i].text, *size);
        return GSF_OK;
    }
    void* read;
    const gsf_result result = gsf_read_file(&f->plain, path, &read, size);
    if (result) return gsf_fail(ctx, result, "%s", f->plain.error);
    *data = gsf_alloc(ctx, *size, 1);
    if (*data) memcpy(*data, read, *size);
    gsf_free(&f->plain, read);
    return *data ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

static gsf_result blip2_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user, (void)data, (void)size;
    return gsf_fail(ctx, GSF_ERROR_IO, "%s", path);
}

static const char* blip2_golden(void) { return test_golden("encoders/blip2"); }

static void blip2_open(blip2_folder* f, gsf_context* ctx) {
    memset(f, 0, sizeof *f);
    test_context_init(&f->plain);
    test_context_zero(ctx);
    ctx->io.read_fn = blip2_read;
    ctx->io.write_fn = blip2_write;
    ctx->io.user = f;
    CHECK_OK(ctx, gsf_init_context(ctx));
}

static void blip2_put(blip2_folder* f, const char* name, const char* text, size_t size) {
    f->files[f->count].name = name;
    f->files[f->count].text = text;
    f->files[f->count++].size = size;
}

// The golden file with `from` replaced by `to`; freed by the caller.
static char* blip2_edit(const char* name, const char* from, const char* to) {
    char path[256];
    size_t size;
    snprintf(path, sizeof path, "encoders/blip2/%s", name);
    char* text = test_read_file(test_golden(path), &size);
    char* at = strstr(text, from);
    char* out = (char*)malloc(size + strlen(to) + 1);
    if (!CHECK(at != NULL)) at = text;
    memcpy(out, text, (size_t)(at - text));
    strcpy(out + (at - text), to);
    strcat(out, at + strlen(from));
    free(text);
    return out;
}

#endif
