// fuzz_bpe.c - the byte-level BPE tokenizer. Build line: fuzz.h. The input is split at zero bytes into vocab.json,
// merges.txt, tokenizer_config.json, special_tokens_map.json, added_tokens.json and arbitrary text, which is also used
// as ids. Encoded text must decode, and decoded text must be UTF-8.
#include "gsfixer_nn.h"

#include "fuzz.h"

enum { FILES = 5 };

typedef struct bytes { const uint8_t* data; size_t size; } bytes;

static const char* const names[FILES] = {"vocab.json", "merges.txt", "tokenizer_config.json", "special_tokens_map.json",
                                         "added_tokens.json"};

static gsf_result read_fn(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    const bytes* files = (const bytes*)user;
    for (size_t i = 0; i < FILES; i++) {
        if (strcmp(strrchr(path, '/') + 1, names[i]) != 0) continue;
        if (i > 1 && files[i].size == 0) break;
        *data = gsf_alloc(ctx, files[i].size, 1);
        FUZZ_CHECK(*data);
        if (files[i].size) memcpy(*data, files[i].data, files[i].size);
        *size = files[i].size;
        return GSF_OK;
    }
    return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: not there", path);
}

static gsf_result write_fn(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user, (void)data, (void)size;
    return gsf_fail(ctx, GSF_ERROR_IO, "%s", path);
}

static void check_utf8(const gsf_buffer* text) {
    const uint8_t* p = (const uint8_t*)text->data;
    for (size_t i = 0; i < text->size;) {
        const size_t more = p[i] < 0x80 ? 0 : p[i] < 0xe0 ? 1 : p[i] < 0xf0 ? 2 : 3;
        FUZZ_CHECK((more == 0 || (p[i] >= 0xc2 && p[i] <= 0xf4)) && text->size - i > more);
        for (i++; i < text->size && (p[i] & 0xc0) == 0x80; i++) {}
        FUZZ_CHECK(i > more && (p[i - more - 1] & 0xc0) != 0x80);
    }
}

static void check_decoded(gsf_context* ctx, const gsf_nn_bpe* bpe, const int32_t* ids, size_t count) {
    for (int skip = 0; skip < 2; skip++) {
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        FUZZ_CHECK(gsf_nn_decode_bpe(ctx, bpe, ids, count, skip, &text) == GSF_OK);
        check_utf8(&text);
        gsf_destroy_buffer(ctx, &text);
    }
}

static void use_tokenizer(gsf_context* ctx, const gsf_nn_bpe* bpe, bytes text) {
    int32_t* ids;
    size_t count;
    const gsf_result result = gsf_nn_encode_bpe(ctx, bpe, (const char*)text.data, text.size, 0, &ids, &count);
    if (result == GSF_OK) {
        FUZZ_CHECK(count <= text.size + 2); // plus a bos token and a leading space
        for (size_t i = 0; i < count; i++) FUZZ_CHECK(ids[i] >= 0 && ids[i] <= bpe->highest_id);
        check_decoded(ctx, bpe, ids, count < 64 ? count : 64); // each may be a token as long as the input
    } else {
        FUZZ_CHECK(result == GSF_ERROR_INVALID_ARGUMENT && ids == NULL && count == 0);
    }
    gsf_free(ctx, ids);
    int32_t any[8];
    const size_t some = text.size / 2 < 8 ? text.size / 2 : 8;
    for (size_t i = 0; i < some; i++) any[i] = (int16_t)(text.data[2 * i] | text.data[2 * i + 1] << 8);
    check_decoded(ctx, bpe, any, some);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    bytes parts[FILES + 1];
    gsf_nn_bpe bpe;
    memset(parts, 0, sizeof parts);
    for (size_t i = 0; i <= FILES; i++) {
        const uint8_t* zero = i < FILES && size ? (const uint8_t*)memchr(data, 0, size) : NULL;
        parts[i].data = data;
        parts[i].size = zero ? (size_t)(zero - data) : size;
        data += zero ? parts[i].size + 1 : parts[i].size;
        size -= zero ? parts[i].size + 1 : parts[i].size;
    }
    ctx.io.read_fn = read_fn;
    ctx.io.write_fn = write_fn;
    ctx.io.user = parts;
    const gsf_result result = gsf_nn_load_bpe(&ctx, "fuzz", &bpe);
    if (result == GSF_OK) use_tokenizer(&ctx, &bpe, parts[FILES]);
    else FUZZ_CHECK((result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED) && ctx.error[0] && !bpe.tables);
    gsf_nn_destroy_bpe(&ctx, &bpe);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
