// fuzz_spz.c - SPZ files, and the gzip inside. Build line: fuzz.h, without -DGSFIXER_IMPLEMENTATION.
//   The input is used three times: as a file; as the content of a file (whose checksum mutations would never match); and
//   as DEFLATE data, with the size of its content in the first two bytes. A few bytes may inflate a thousandfold, and all
//   these splats are read, packed and read again, so allocations beyond a quarter of a MiB fail. Packing takes ten times as
//   long as reading, so only one input in eight (by hash) is packed.
#define GSFIXER_IMPLEMENTATION
#include "fuzz.h"

static int packs;

// Accepted splats are finite and, unless a coordinate is out of SPZ's range, survive being written and read again.
static void use(gsf_context* ctx, gsf_splats* splats) {
    gsf_splats again;
    gsf_buffer text;
    const size_t sh = 3 * (size_t)gsf_splat_count_sh(splats->sh_degree);
    memset(&text, 0, sizeof text);
    for (size_t i = 0; i < 3 * splats->count; i++)
        FUZZ_CHECK(isfinite(splats->means[i]) && isfinite(splats->log_scales[i]));
    for (size_t i = 0; i < 4 * splats->count; i++) FUZZ_CHECK(isfinite(splats->quats[i]));
    for (size_t i = 0; i < splats->count; i++) FUZZ_CHECK(isfinite(splats->opacity_logits[i]));
    for (size_t i = 0; i < sh * splats->count; i++) FUZZ_CHECK(isfinite(splats->sh[i]));
    const gsf_result result = packs ? gsf_splat_format(ctx, "again.spz", splats, NULL, &text) : GSF_ERROR_UNSUPPORTED;
    FUZZ_CHECK(result == GSF_OK || result == GSF_ERROR_UNSUPPORTED || result == GSF_ERROR_OUT_OF_MEMORY);
    const gsf_result read = result == GSF_OK ? gsf_splat_parse(ctx, "again.spz", text.data, text.size, &again) : result;
    FUZZ_CHECK(result != GSF_OK || read == GSF_OK || read == GSF_ERROR_OUT_OF_MEMORY);
    if (read == GSF_OK) {
        FUZZ_CHECK(again.count == splats->count && again.sh_degree == splats->sh_degree &&
                   again.antialiased == splats->antialiased);
        FUZZ_CHECK(memcmp(again.log_scales, splats->log_scales, 3 * splats->count * sizeof(float)) == 0);
        FUZZ_CHECK(memcmp(again.opacity_logits, splats->opacity_logits, splats->count * sizeof(float)) == 0);
        gsf_splat_destroy(ctx, &again);
    }
    gsf_destroy_buffer(ctx, &text);
    gsf_splat_destroy(ctx, splats);
}

static void parse(gsf_context* ctx, const void* data, size_t size) {
    gsf_splats splats;
    const gsf_result result = gsf_splat_parse(ctx, "fuzz.spz", data, size, &splats);
    if (result == GSF_OK) use(ctx, &splats);
    else if (result != GSF_ERROR_OUT_OF_MEMORY) fuzz_check_error(ctx, "fuzz.spz:");
    FUZZ_CHECK(splats.owned == NULL);
}

// Packing and unpacking gives the same bytes.
static void check_gzip(gsf_context* ctx, const uint8_t* data, size_t size) {
    gsf_buffer packed;
    unsigned char* back;
    size_t back_size;
    memset(&packed, 0, sizeof packed);
    FUZZ_CHECK(gsf__gzip_append(ctx, "packed", data, size, &packed) == GSF_OK);
    FUZZ_CHECK(packed.size <= size + 6 * (size / 32767 + 1) + 18); // a header per stored block, padded to whole bytes
    const unsigned char* bytes = (const unsigned char*)packed.data;
    FUZZ_CHECK(gsf__gzip_read(ctx, "packed", bytes, packed.size, &back, &back_size) == GSF_OK);
    FUZZ_CHECK(back_size == size && memcmp(back, data, size) == 0);
    gsf_free(ctx, back);
    gsf_destroy_buffer(ctx, &packed);
}

// A gzip file with the bytes in stored (uncompressed) DEFLATE blocks.
static gsf_buffer store(gsf_context* ctx, const uint8_t* data, size_t size) {
    static const char head[10] = "\x1f\x8b\x08\0\0\0\0\0\0";
    gsf_buffer file;
    char tail[8];
    memset(&file, 0, sizeof file);
    gsf_append_bytes(ctx, &file, head, sizeof head);
    for (size_t at = 0; at < size;) {
        const size_t bytes = size - at < 65535 ? size - at : 65535;
        const char block[5] = {at + bytes == size, (char)(bytes & 255), (char)(bytes >> 8), (char)(~bytes & 255),
                               (char)(~bytes >> 8 & 255)};
        gsf_append_bytes(ctx, &file, block, sizeof block);
        gsf_append_bytes(ctx, &file, (const char*)data + at, bytes);
        at += bytes;
    }
    gsf__store_le(tail, gsf__crc32(0, data, size), 4);
    gsf__store_le(tail + 4, size & 0xffffffffu, 4);
    gsf_append_bytes(ctx, &file, tail, sizeof tail);
    FUZZ_CHECK(!file.failed);
    return file;
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    packs = size > 0 && gsf__crc32(0, data, size) % 8 == 0;
    gsf_context ctx = fuzz_context(size);
    fuzz_limit = (size_t)(16 * GSF__DEFLATE_RATIO) * size + ((size_t)4 << 20); // DEFLATE's largest expansion
    fuzz_room = 16 * size + ((size_t)1 << 18) + sizeof(gsf__deflater);
    parse(&ctx, data, size);

    if (size > 0 && packs) check_gzip(&ctx, data, size);
    if (size > 0) {
        gsf_buffer file = store(&ctx, data, size);
        parse(&ctx, file.data, file.size);
        gsf_destroy_buffer(&ctx, &file);
    }
    if (size > 2) {
        const size_t room = 1 + data[0] + 256u * (data[1] & 15u);
        unsigned char *out = (unsigned char*)malloc(room), *body = (unsigned char*)malloc(size - 2 + 8);
        FUZZ_CHECK(out && body); // of exact sizes, so that a sanitizer detects any overrun
        memcpy(body, data + 2, size - 2);
        memset(body + size - 2, 0xa5, 8); // in place of the checksum and size of a file
        (void)gsf__inflate(&ctx, "raw", body, size - 2 + 8, 0, out, room);
        free(body);
        free(out);
    }
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
