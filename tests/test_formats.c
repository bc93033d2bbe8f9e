// test_formats.c - .splat, .spz and .glb: hand-made files, files written by Niantic's spz library, error bounds of a round
// trip, damage, failing allocations, non-finite splats, positions out of range; and the gzip layer.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"
#include "test_hooks.h"

#ifdef TEST_GOLDEN
#define TESTS TEST_GOLDEN "/.."
#else
#define TESTS "tests"
#endif

#ifdef GSF_USE_ZSTD
enum { ZSTD = 1 };
#else
enum { ZSTD = 0 };
#endif

static gsf_context make_context(counter* c, int odd) {
    gsf_context ctx;
    test_context_zero(&ctx);
    memset(c, 0, sizeof *c);
    count_memory(&ctx, c);
    ctx.logger.log_fn = keep_warning;
    if (odd) work_backwards(&ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    warnings = 0;
    warning[0] = 0;
    return ctx;
}

static int is_refusal(gsf_result r) {
    return r == GSF_ERROR_FORMAT || r == GSF_ERROR_UNSUPPORTED || r == GSF_ERROR_NUMERIC;
}

// A gzip file with the content in one stored block; computes its own CRC. Freed by the caller.
static unsigned char* wrap(const void* content, size_t size, size_t* out_size) {
    static const unsigned char head[11] = {0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3, 1};
    unsigned char* p = (unsigned char*)malloc(size + 23);
    uint32_t crc = 0xffffffffu;
    for (size_t i = 0; i < size; i++) {
        crc ^= ((const unsigned char*)content)[i];
        for (int k = 0; k < 8; k++) crc = crc & 1u ? crc >> 1 ^ 0xedb88320u : crc >> 1;
    }
    memcpy(p, head, sizeof head);
    const uint32_t words[2] = {~crc, (uint32_t)size};
    for (int k = 0; k < 2; k++) {
        p[11 + k] = (unsigned char)(size >> 8 * k);
        p[13 + k] = (unsigned char)~(size >> 8 * k);
    }
    memcpy(p + 15, content, size);
    for (int k = 0; k < 8; k++) p[15 + size + (size_t)k] = (unsigned char)(words[k / 4] >> 8 * (k % 4));
    *out_size = size + 23;
    return p;
}

// Content of a gzip file; gsf_free'd by the caller.
static unsigned char* unwrap(gsf_context* ctx, const void* file, size_t size, size_t* out_size) {
    unsigned char* content;
    CHECK_OK(ctx, gsf__gzip_read(ctx, "file", (const unsigned char*)file, size, &content, out_size));
    return content;
}

// ---- by hand -------------------------------------------------------------------

static void test_splat_by_hand(void) {
    // 1, -2, 0.5 | scales 1, 2, 0.25 | red all, green none, blue 51, opacity 204 | quaternion 127/128, 0, -1, 0.5
    static const unsigned char file[32] = {0, 0, 0x80, 0x3f, 0, 0, 0,    0xc0, 0, 0, 0,    0x3f, 0,   0,   0x80, 0x3f,
                                           0, 0, 0,    0x40, 0, 0, 0x80, 0x3e, 255, 0, 51, 204,  255, 128, 0,    192};
    static const unsigned char written[64] = {
        0, 0, 0x80, 0x3f, 0, 0, 0, 0xc0, 0, 0, 0, 0x3f, 0, 0, 0x80, 0x3f, 0, 0, 0x80, 0x3f, 0, 0, 0x80, 0x3f,
        255, 0, 128, 128, 255, 128, 128, 128, // colours 3.3, -2.3, 0.5; opacity 0.5; w = 1, which saturates
        0, 0, 0x40, 0x40, 0, 0, 0, 0, 0, 0, 0x80, 0xc0, 0, 0, 0x80, 0x3f, 0, 0, 0x80, 0x3f, 0, 0, 0x80, 0x3f,
        128, 128, 128, 255, 128, 128, 0, 128}; // 3, 0, -4; opacity 1 - 5e-5; y = -2 before it is normalised
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s;
    if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "hand.SPLAT", file, sizeof file, &s))) {
        CHECK(s.count == 1 && s.sh_degree == 0 && s.origin[0] == 0.0 && s.ids[0] == 0);
        CHECK(s.means[0] == 1.0f && s.means[1] == -2.0f && s.means[2] == 0.5f);
        CHECK_NEAR(s.log_scales[0], 0.0, 1e-7);
        CHECK_NEAR(s.log_scales[1], 0.69314718, 1e-6);
        CHECK_NEAR(s.log_scales[2], -1.38629436, 1e-6);
        CHECK_NEAR(s.sh[0], 1.77245385, 1e-6); // 0.5 / 0.28209479
        CHECK_NEAR(s.sh[1], -1.77245385, 1e-6);
        CHECK_NEAR(s.sh[2], -1.06347231, 1e-6); // (0.2 - 0.5) / 0.28209479
        CHECK_NEAR(s.opacity_logits[0], 1.38629436, 1e-6); // 0.8
        CHECK(s.quats[0] == 127.0f / 128.0f && s.quats[1] == 0.0f && s.quats[2] == -1.0f && s.quats[3] == 0.5f);
        gsf_splat_destroy(&ctx, &s);
    }
    CHECK_OK(&ctx, gsf_splat_make(&ctx, 2, 1, &s)); // band 1 is not stored
    const float means[6] = {1.0f, -2.0f, 0.5f, 3.0f, 0.0f, -4.0f};
    const float quats[8] = {1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, -2.0f, 0.0f};
    memcpy(s.means, means, sizeof means);
    memcpy(s.quats, quats, sizeof quats);
    s.sh[0] = 10.0f;
    s.sh[1] = -10.0f;
    s.sh[5] = 0.7f;
    s.opacity_logits[1] = 10.0f;
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    if (CHECK_OK(&ctx, gsf_splat_format(&ctx, "hand.splat", &s, NULL, &text)))
        CHECK(text.size == sizeof written && memcmp(text.data, written, sizeof written) == 0);
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0 && warnings == 0);
}

enum { HEAD = 16 };
#define SPZ_HEAD(version, degree) 'N', 'G', 'S', 'P', version, 0, 0, 0, 1, 0, 0, 0, degree, 12, 1, 0
// opacity 0.5 | colours 0, 1, -1 | log-scales -5, 0, -9
#define SPZ_MIDDLE 128, 128, 166, 89, 80, 160, 16
// band 1, rgb of y, z, x: 0.25 -0.25 0 | 0.5 1 -1 | 0.03 0.04 -0.03, those of y and z negated, in steps of 8
#define SPZ_SH 96, 160, 128, 64, 0, 255, 136, 136, 128
// 1.5, -0.25, 2 as 24 bits in units of 1/4096, y and z negated
#define SPZ_FIXED 0x00, 0x18, 0x00, 0x00, 0x04, 0x00, 0x00, 0xe0, 0xff
static const unsigned char spz_by_hand[3][45] = {
    {SPZ_HEAD(1, 1), 0x00, 0x3e, 0x00, 0x34, 0x00, 0xc0, SPZ_MIDDLE, 191, 64, 64, SPZ_SH}, // float16 x, y, z
    {SPZ_HEAD(2, 1), SPZ_FIXED, SPZ_MIDDLE, 191, 64, 64, SPZ_SH},
    // x is the largest (first of equals): index 0 | -361 | -361 | 361 in 10 bits each, 361 = 511 * 0.5 / sqrt(0.5)
    {SPZ_HEAD(3, 1), SPZ_FIXED, SPZ_MIDDLE, 0x69, 0xa5, 0x9d, 0x36, SPZ_SH},
};
static const size_t spz_by_hand_size[3] = {41, 44, 45};

static gsf_splats hand_splats(gsf_context* ctx) {
    static const float mean[3] = {1.5f, -0.25f, 2.0f}, scale[3] = {-5.0f, 0.0f, -9.0f};
    static const float sh[12] = {0.0f, 1.0f, -1.0f, 0.25f, -0.25f, 0.0f, 0.5f, 1.0f, -1.0f, 0.03f, 0.04f, -0.03f};
    gsf_splats s;
    CHECK_OK(ctx, gsf_splat_make(ctx, 1, 1, &s));
    memcpy(s.means, mean, sizeof mean);
    memcpy(s.log_scales, scale, sizeof scale);
    memcpy(s.sh, sh, sizeof sh);
    for (int k = 0; k < 4; k++) s.quats[k] = -0.5f; // the same rotation as +0.5
    s.antialiased = 1;
    return s;
}

static void test_spz_by_hand(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s;
    for (int version = 1; version <= 3; version++) {
        size_t size;
        unsigned char* file = wrap(spz_by_hand[version - 1], spz_by_hand_size[version - 1], &size);
        if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "hand.spz", file, size, &s))) {
            static const double sh[12] = {0.5 / 255 / 0.15, (166 / 255.0 - 0.5) / 0.15, (89 / 255.0 - 0.5) / 0.15,
                                          0.25, -0.25, 0, 0.5, 1, -127 / 128.0, 0.0625, 0.0625, 0};
            CHECK(s.count == 1 && s.sh_degree == 1 && s.antialiased == 1);
            CHECK(s.means[0] == 1.5f && s.means[1] == -0.25f && s.means[2] == 2.0f);
            CHECK(s.log_scales[0] == -5.0f && s.log_scales[1] == 0.0f && s.log_scales[2] == -9.0f);
            CHECK_NEAR(s.opacity_logits[0], log(128.0 / 127.0), 1e-6);
            test_compare_floats("sh by hand", s.sh, sh, 12, 1e-6);
            // 191 / 127.5 - 1, or sqrt(0.5) * 361 / 511; one component is derived from the other three
            for (int k = 0; k < 4; k++) {
                const int derived = version < 3 ? 0 : 1;
                CHECK_NEAR(s.quats[k], version < 3 ? (k == derived ? 0.505837 : 0.498039)
                                                   : (k == derived ? 0.501374 : 0.499541), 1e-5);
            }
            gsf_splat_destroy(&ctx, &s);
        }
        free(file);
    }
    s = hand_splats(&ctx);
    for (int version = 2; version <= 3; version++) {
        gsf_splat_save_desc desc = {GSF_SPLAT_SPZ, 0, version};
        gsf_buffer text;
        size_t size;
        memset(&text, 0, sizeof text);
        if (CHECK_OK(&ctx, gsf_splat_format(&ctx, "any name", &s, &desc, &text))) {
            unsigned char* content = unwrap(&ctx, text.data, text.size, &size);
            CHECK(size == spz_by_hand_size[version - 1] && memcmp(content, spz_by_hand[version - 1], size) == 0);
            gsf_free(&ctx, content);
        }
        gsf_destroy_buffer(&ctx, &text);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0 && warnings == 0);
}

// Niantic's library (nianticlabs/spz 21715c3: loadSplatFromPly and saveSpz with RDF axes, antialiased set) made
// corpus/spz/official_v2 and _v3 from a golden PLY. Our decompressed content must equal theirs byte for byte.
static void test_official(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s, official;
    if (!CHECK_OK(&ctx, gsf_splat_load(&ctx, TESTS "/golden/splat/ply/random_deg3.ply", &s))) return;
    s.antialiased = 1;
    for (int version = 2; version <= 3; version++) {
        char path[1024];
        gsf_splat_save_desc desc = {GSF_SPLAT_SPZ, 0, version};
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        snprintf(path, sizeof path, "%s/corpus/spz/official_v%d", TESTS, version);
        size_t file_size, size, our_size;
        char* file = test_read_file(path, &file_size);
        if (CHECK_OK(&ctx, gsf_splat_format(&ctx, "ours.spz", &s, &desc, &text))) {
            unsigned char* content = unwrap(&ctx, file, file_size, &size);
            unsigned char* ours = unwrap(&ctx, text.data, text.size, &our_size);
            CHECK(size == our_size && size > HEAD);
            size_t differ = 0;
            for (size_t i = 0; i < size && i < our_size; i++) differ += i != 13 && content[i] != ours[i];
            if (content[13] != ours[13]) fprintf(stderr, "%d fraction bits, not %d\n", ours[13], content[13]);
            CHECK(differ == 0 && content[13] == ours[13]);
            gsf_free(&ctx, content);
            gsf_free(&ctx, ours);
            CHECK(text.size <= file_size + file_size / 4); // zlib's files are smaller, with dynamic Huffman codes
        }
        gsf_destroy_buffer(&ctx, &text);
        if (CHECK_OK(&ctx, gsf_splat_load(&ctx, path, &official))) { // format detected from the content
            CHECK(official.count == s.count && official.sh_degree == 3 && official.antialiased == 1);
            gsf_splat_destroy(&ctx, &official);
        }
        free(file);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

// Version 4, by the same library in the same way: equal heads but for the fraction bits, equal arrays after decompression.
// Cut or changed anywhere, a file is refused, or gives splats (zstd frames have no checksum by default).
static void test_official_4(void) {
#ifdef GSF_USE_ZSTD
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s, official;
    gsf_buffer text;
    size_t size;
    const gsf_splat_save_desc desc = {GSF_SPLAT_SPZ, 0, 4};
    memset(&text, 0, sizeof text);
    if (!CHECK_OK(&ctx, gsf_splat_load(&ctx, TESTS "/golden/splat/ply/random_deg3.ply", &s))) return;
    s.antialiased = 1;
    unsigned char* file = (unsigned char*)test_read_file(TESTS "/corpus/spz/official_v4", &size);
    CHECK_OK(&ctx, gsf_splat_format(&ctx, "ours.spz", &s, &desc, &text));
    gsf__spz theirs, ours;
    unsigned char *a = NULL, *b = NULL;
    CHECK_OK(&ctx, gsf__spz_inflate(&ctx, "theirs", file, size, &theirs, &a));
    CHECK_OK(&ctx, gsf__spz_inflate(&ctx, "ours", (unsigned char*)text.data, text.size, &ours, &b));
    if (a && b) {
        CHECK(memcmp(file, text.data, 13) == 0 && memcmp(file + 14, text.data + 14, 18) == 0 && theirs.size == ours.size);
        CHECK(file[13] == (unsigned char)text.data[13]);
        CHECK(memcmp(a + HEAD, b + HEAD, ours.size - HEAD) == 0);
    }
    gsf_free(&ctx, a);
    gsf_free(&ctx, b);
    if (CHECK_OK(&ctx, gsf_splat_load(&ctx, TESTS "/corpus/spz/official_v4", &official))) {
        CHECK(official.count == s.count && official.sh_degree == 3 && official.antialiased == 1);
        gsf_splat_destroy(&ctx, &official);
    }
    for (size_t at = 0; at < size; at += at < 200 ? 1 : 29) {
        unsigned char* part = (unsigned char*)exact_copy(file, at);
        CHECK(is_refusal(gsf_splat_parse(&ctx, "cut.spz", part, at, &official)) && !official.owned);
        free(part);
        for (int flip = 1; flip < 256; flip += 17) {
            unsigned char* whole = (unsigned char*)exact_copy(file, size);
            whole[at] ^= (unsigned char)flip;
            const gsf_result r = gsf_splat_parse(&ctx, "flip.spz", whole, size, &official);
            CHECK(r == GSF_OK || (is_refusal(r) && !official.owned));
            gsf_splat_destroy(&ctx, &official);
            free(whole);
        }
    }
    free(file);
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
#endif
}

// ---- round trips ---------------------------------------------------------------

static gsf_splats random_splats(gsf_context* ctx, size_t n, int32_t degree, double extent, uint64_t seed) {
    gsf_splats s;
    CHECK_OK(ctx, gsf_splat_make(ctx, n, degree, &s));
    const size_t sh = (size_t)gsf_splat_count_sh(degree);
    for (size_t i = 0; i < 3 * n; i++) s.means[i] = (float)test_random_in(&seed, -extent, extent);
    for (size_t i = 0; i < 3 * n; i++) s.log_scales[i] = (float)test_random_in(&seed, -8, 5);
    for (size_t i = 0; i < 4 * n; i++) s.quats[i] = (float)test_random_in(&seed, -3, 3);
    for (size_t i = 0; i < n; i++) s.opacity_logits[i] = (float)test_random_in(&seed, -6, 6);
    for (size_t i = 0; i < 3 * sh * n; i++) s.sh[i] = (float)test_random_in(&seed, -0.9, 0.9);
    if (n > 1) for (int k = 0; k < 4; k++) s.quats[4 + k] = 0.0f; // the identity
    return s;
}

static double sigmoid(double x) { return 1.0 / (1.0 + exp(-x)); }

typedef struct bounds { double mean, log_scale, opacity, dc, band1, rest, quat; } bounds; // quat: normalised, up to sign

static void check_close(const gsf_splats* a, const gsf_splats* b, bounds most) {
    bounds worst = {0, 0, 0, 0, 0, 0, 0};
    const size_t ka = (size_t)gsf_splat_count_sh(a->sh_degree), kb = (size_t)gsf_splat_count_sh(b->sh_degree);
    CHECK(a->count == b->count && (kb == ka || kb == 1));
    if (a->count != b->count) return;
    for (size_t i = 0; i < a->count; i++) {
        float qa[4], qb[4];
        double same = 0, opposite = 0;
        gsf__unit_quat(a->quats + 4 * i, qa);
        gsf__unit_quat(b->quats + 4 * i, qb);
        for (size_t k = 0; k < 3; k++) {
            worst.mean = fmax(worst.mean, fabs(a->origin[k] - b->origin[k] + a->means[3 * i + k] - b->means[3 * i + k]));
            worst.log_scale = fmax(worst.log_scale, fabs((double)a->log_scales[3 * i + k] - b->log_scales[3 * i + k]));
        }
        for (size_t k = 0; k < 4; k++) {
            same = fmax(same, fabs((double)qa[k] - qb[k]));
            opposite = fmax(opposite, fabs((double)qa[k] + qb[k]));
        }
        worst.quat = fmax(worst.quat, fmin(same, opposite));
        worst.opacity = fmax(worst.opacity, fabs(sigmoid(a->opacity_logits[i]) - sigmoid(b->opacity_logits[i])));
        for (size_t k = 0; k < kb; k++)
            for (size_t c = 0; c < 3; c++) {
                const double error = fabs((double)a->sh[3 * (ka * i + k) + c] - b->sh[3 * (kb * i + k) + c]);
                double* to = k == 0 ? &worst.dc : k < 4 ? &worst.band1 : &worst.rest;
                *to = fmax(*to, error);
            }
    }
    const int before = test_failures;
    CHECK(worst.mean <= most.mean);
    CHECK(worst.log_scale <= most.log_scale);
    CHECK(worst.opacity <= most.opacity);
    CHECK(worst.dc <= most.dc);
    CHECK(worst.band1 <= most.band1);
    CHECK(worst.rest <= most.rest);
    CHECK(worst.quat <= most.quat);
    if (test_failures > before)
        fprintf(stderr, "worst: mean %g scale %g opacity %g dc %g band1 %g rest %g quat %g\n", worst.mean, worst.log_scale,
                worst.opacity, worst.dc, worst.band1, worst.rest, worst.quat);
}

static void test_round_trips(void) {
    static const size_t counts[4] = {0, 1, 2, 5000};
    const double u8 = 0.5 / 255 * 1.001; // SH is rounded twice: to 1/128, then to 8 or 16 of these
    // Version 2 quaternions: x, y, z to half a step of 1/127.5; w follows from them, so near w = 0 it can be off by
    // sqrt(3 * 2 * 0.0039), which the format accepts.
    const bounds spz3 = {0.5 / 4096 * 1.001, 1.0 / 32 * 1.001, u8, u8 / 0.15, 4.5 / 128 * 1.001, 8.5 / 128 * 1.001, 0.002};
    bounds spz2 = spz3;
    spz2.quat = 0.16;
    const bounds glb = {0, 2e-6, 1e-7, 0, 0, 0, 1e-6};
    const bounds splat = {2e-6, 2e-6, u8, u8 / 0.2820947, 0, 0, 0.012};
    for (size_t c = 0; c < 4; c++)
        for (int32_t degree = 0; degree <= 3; degree++)
            for (int kind = 0; kind < 5; kind++) { // .splat, SPZ 2, SPZ 3, .glb, SPZ 4
                if (kind == 3 && counts[c] == 0) continue; // glTF has no empty arrays
                if (kind == 4 && !ZSTD) continue;
                counter count;
                gsf_context ctx = make_context(&count, 0);
                gsf_splats s = random_splats(&ctx, counts[c], degree, 15.0, 100 * c + (uint64_t)degree), again;
                gsf_splat_save_desc desc = {GSF_SPLAT_AUTO, 0, kind == 1 ? 2 : kind == 4 ? 4 : 0};
                const char* path = test_scratch(kind == 3 ? "trip.glb" : kind ? "trip.spz" : "trip.splat");
                s.antialiased = degree & 1;
                CHECK_OK(&ctx, gsf_splat_save(&ctx, path, &s, &desc));
                if (CHECK_OK(&ctx, gsf_splat_load(&ctx, path, &again))) {
                    CHECK(again.antialiased == (kind % 3 ? s.antialiased : 0) && again.sh_degree == (kind ? degree : 0));
                    check_close(&s, &again, kind == 0 ? splat : kind == 1 ? spz2 : kind == 3 ? glb : spz3);
                    gsf_splat_destroy(&ctx, &again);
                }
                gsf_splat_destroy(&ctx, &s);
                CHECK(count.live == 0 && warnings == 0);
            }
}

// A .ply file keeps the background, as a comment. Other comments, however similar, mean nothing.
static void test_background(void) {
    static const char* const comments[] = {"comment background 0.25 0.5 0.75", "comment background", "comment background 1 2",
                                           "comment background 1 1 1 1", "comment background 1 x 1", "comment background nan 0 0",
                                           "comment background 1 1 1e30", "comment backgrounds 1 1 1", "obj_info background 1 1 1"};
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s = random_splats(&ctx, 5, 1, 2.0, 7), again;
    const float colors[2][3] = {{0.1f, 0.0f, 1.0f}, {0.0f, 0.0f, 0.0f}};
    for (int i = 0; i < 2; i++) {
        gsf_buffer text = {0};
        memcpy(s.background, colors[i], sizeof s.background);
        CHECK_OK(&ctx, gsf_splat_format(&ctx, "x.ply", &s, NULL, &text));
        CHECK((memcmp(text.data + 36, "comment background ", 19) == 0) == (i == 0)); // after "ply" and the format
        if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "x.ply", text.data, text.size, &again))) {
            CHECK(again.count == 5 && memcmp(again.background, colors[i], sizeof again.background) == 0);
            gsf_splat_destroy(&ctx, &again);
        }
        for (size_t c = 0; c < sizeof comments / sizeof *comments && i == 1; c++) {
            gsf_buffer other = {0};
            gsf_append_text(&ctx, &other, "%.36s%s\n", text.data, comments[c]);
            gsf_append_bytes(&ctx, &other, text.data + 36, text.size - 36);
            if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "x.ply", other.data, other.size, &again))) {
                CHECK(again.background[0] == (c == 0 ? 0.25f : 0.0f) && again.background[2] == (c == 0 ? 0.75f : 0.0f));
                gsf_splat_destroy(&ctx, &again);
            }
            gsf_destroy_buffer(&ctx, &other);
        }
        gsf_destroy_buffer(&ctx, &text);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0 && warnings == 0);
}

// The file does not depend on the order of chunks or the worker that runs them.
static void test_workers(void) {
    counter count, odd_count;
    gsf_context ctx = make_context(&count, 0), odd = make_context(&odd_count, 1);
    gsf_splats s = random_splats(&ctx, 20000, 3, 2.0, 5), again;
    static const char* const names[3] = {"x.splat", "x.spz", "x.glb"};
    for (int i = 0; i < 3; i++) {
        gsf_buffer a, b;
        memset(&a, 0, sizeof a);
        memset(&b, 0, sizeof b);
        CHECK_OK(&ctx, gsf_splat_format(&ctx, names[i], &s, NULL, &a));
        CHECK_OK(&odd, gsf_splat_format(&odd, names[i], &s, NULL, &b));
        CHECK(a.size == b.size && memcmp(a.data, b.data, a.size) == 0);
        if (CHECK_OK(&odd, gsf_splat_parse(&odd, names[i], b.data, b.size, &again))) {
            CHECK(again.count == s.count);
            CHECK_NEAR(again.means[3 * 19999], s.means[3 * 19999], 0.5 / 4096);
            gsf_splat_destroy(&odd, &again);
        }
        gsf_destroy_buffer(&ctx, &a);
        gsf_destroy_buffer(&odd, &b);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0 && odd_count.live == 0);
}

// ---- out of range ---------------------------------------------------------

static void test_format_not_finite(void) {
    static const float evil[3] = {NAN, INFINITY, -INFINITY};
    static const char* const names[3] = {"x.splat", "x.spz", "x.glb"};
    for (int attribute = 0; attribute < 5; attribute++)
        for (int e = 0; e < 3; e++)
            for (int f = 0; f < 3; f++) {
                counter count;
                gsf_context ctx = make_context(&count, 0);
                gsf_splats s = random_splats(&ctx, 5, 1, 1.0, 3), again;
                float* arrays[5] = {s.means + 3 * 2, s.log_scales + 3 * 2 + 1, s.quats + 4 * 2 + 3, s.opacity_logits + 2,
                                    s.sh + 12 * 2 + 11};
                gsf_buffer text;
                memset(&text, 0, sizeof text);
                arrays[attribute][0] = evil[e];
                CHECK_OK(&ctx, gsf_splat_format(&ctx, names[f], &s, NULL, &text));
                CHECK(warnings == 1 && strstr(warning, "1 of 5 splats left out"));
                if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, names[f], text.data, text.size, &again))) {
                    CHECK(again.count == 4 && again.ids[3] == 3);
                    CHECK_NEAR(again.means[3 * 2], s.means[3 * 3], 1.0 / 4096); // the splats after it moved up
                    gsf_splat_destroy(&ctx, &again);
                }
                gsf_destroy_buffer(&ctx, &text);
                gsf_splat_destroy(&ctx, &s);
                CHECK(count.live == 0);
            }
    // Reading: a NaN position, a negative and an infinite scale; scales of 0 are accepted. Writing: all limits.
    counter count;
    gsf_context ctx = make_context(&count, 0);
    unsigned char rows[5 * 32];
    memset(rows, 0, sizeof rows);
    memcpy(rows + 32, "\0\0\xc0\x7f", 4);
    memcpy(rows + 64 + 12, "\0\0\x80\xbf", 4);
    memcpy(rows + 96 + 20, "\0\0\x80\x7f", 4);
    memset(rows + 128 + 24, 255, 4);
    gsf_splats s;
    if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "x.splat", rows, sizeof rows, &s))) {
        CHECK(s.count == 2 && warnings == 1 && strstr(warning, "3 of 5 splats dropped"));
        CHECK_NEAR(s.log_scales[0], -87.33654, 1e-4);
        CHECK_NEAR(s.opacity_logits[0], -6.9265, 1e-3);
        CHECK_NEAR(s.opacity_logits[1], 6.9265, 1e-3);
        for (size_t i = 0; i < 3; i++) s.log_scales[i] = 1e30f;
        s.opacity_logits[0] = -3e38f;
        s.opacity_logits[1] = 3e38f;
        for (size_t i = 0; i < 8; i++) s.quats[i] = i < 4 ? 3e38f : 1e-45f;
        for (size_t i = 0; i < 6; i++) s.sh[i] = i < 3 ? -3e38f : 3e38f;
        for (int f = 0; f < 3; f++) {
            static const char* const limits[3] = {"y.splat", "y.spz", "y.glb"};
            gsf_buffer text;
            gsf_splats again;
            memset(&text, 0, sizeof text);
            CHECK_OK(&ctx, gsf_splat_format(&ctx, limits[f], &s, NULL, &text));
            if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, limits[f], text.data, text.size, &again))) {
                CHECK(again.count == 2);
                for (size_t i = 0; i < 8; i++) CHECK_NEAR(again.quats[i], 0.5, 0.005);
                gsf_splat_destroy(&ctx, &again);
            }
            gsf_destroy_buffer(&ctx, &text);
        }
        gsf_splat_destroy(&ctx, &s);
    }
    CHECK(count.live == 0);
}

static int fraction_of(gsf_context* ctx, const gsf_splats* s, const gsf_splat_save_desc* desc) { // -1: refused
    gsf_buffer text;
    size_t size;
    int fraction = -1;
    memset(&text, 0, sizeof text);
    if (gsf_splat_format(ctx, "x.spz", s, desc, &text) == GSF_OK) {
        unsigned char* content = unwrap(ctx, text.data, text.size, &size);
        fraction = content[13];
        gsf_free(ctx, content);
    }
    gsf_destroy_buffer(ctx, &text);
    return fraction;
}

static void test_extent(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    const gsf_splat_save_desc local = {GSF_SPLAT_SPZ, 1, 0}, wrong = {GSF_SPLAT_SPZ, 0, 1};
    gsf_splats s = random_splats(&ctx, 300, 0, 3.0, 9), again;
    gsf_buffer text;
    for (size_t i = 0; i < 3 * s.count; i++) s.log_scales[i] = -4.0f;
    CHECK(fraction_of(&ctx, &s, NULL) == 12 && warnings == 0);
    s.means[5] = 2047.99f;
    CHECK(fraction_of(&ctx, &s, NULL) == 12 && warnings == 0);
    s.means[5] = -2048.0f;
    CHECK(fraction_of(&ctx, &s, NULL) == 11 && warnings == 0);
    s.means[5] = 8388607.0f; // one outlier reduces the precision of all the others, with a warning
    CHECK(fraction_of(&ctx, &s, NULL) == 0 && warnings == 1 && strstr(warning, "steps of 1 here"));
    s.means[5] = 8388608.0f;
    CHECK(fraction_of(&ctx, &s, NULL) == -1 && strstr(ctx.error, "8388608") && strstr(ctx.error, "x.spz"));
    s.means[5] = 0.0f;
    CHECK(fraction_of(&ctx, &s, &wrong) == -1 && strstr(ctx.error, "version 1"));
    // Small scenes get more fraction bits, for the same relative precision
    for (size_t i = 0; i < 3 * s.count; i++) {
        s.means[i] *= 1e-3f;
        s.log_scales[i] -= 6.9f;
    }
    CHECK(fraction_of(&ctx, &s, NULL) == 21);
    // Far from the origin: both formats warn, and keep every splat in local coordinates
    warnings = 0;
    for (size_t i = 0; i < 3 * s.count; i++) {
        s.means[i] *= 1e3f;
        s.log_scales[i] += 6.9f;
    }
    s.origin[0] = 4512345.0;
    s.origin[2] = 5400000.25;
    CHECK(fraction_of(&ctx, &s, NULL) == 0 && warnings == 1);
    CHECK(fraction_of(&ctx, &s, &local) == 12 && warnings == 1);
    for (int is_local = 0; is_local < 2; is_local++) {
        const gsf_splat_save_desc desc = {GSF_SPLAT_SPLAT, is_local, 0};
        memset(&text, 0, sizeof text);
        warnings = 0;
        CHECK_OK(&ctx, gsf_splat_format(&ctx, "far", &s, &desc, &text));
        CHECK(warnings == !is_local);
        if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "far.splat", text.data, text.size, &again))) {
            double worst = 0.0;
            for (size_t i = 0; i < 3 * s.count; i++) {
                const double moved = again.origin[i % 3] - (is_local ? 0.0 : s.origin[i % 3]);
                worst = fmax(worst, fabs(moved + again.means[i] - s.means[i]));
            }
            CHECK(worst <= (is_local ? 0.0 : 0.2501) && (again.origin[0] != 0.0) == !is_local);
            gsf_splat_destroy(&ctx, &again);
        }
        gsf_destroy_buffer(&ctx, &text);
    }
    s.log_scales[0] = 7.0f; // larger than SPZ holds
    warnings = 0;
    CHECK(fraction_of(&ctx, &s, &local) >= 0 && warnings == 1 && strstr(warning, "1 of 300 splats are larger"));
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

static void test_types(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s = random_splats(&ctx, 7, 2, 1.0, 11), again;
    static const gsf_splat_type types[4] = {GSF_SPLAT_PLY, GSF_SPLAT_SPLAT, GSF_SPLAT_SPZ, GSF_SPLAT_GLB};
    static const char* const names[5] = {"a.ply", "a.SPLAT", "a.Spz", "a.glB", "a"};
    for (int t = 0; t < 4; t++) {
        gsf_buffer text;
        gsf_splat_save_desc desc = {types[t], 0, 0};
        memset(&text, 0, sizeof text);
        CHECK_OK(&ctx, gsf_splat_format(&ctx, "nothing", &s, &desc, &text));
        for (int n = 0; n < 5; n++) {
            const gsf_result r = gsf_splat_parse(&ctx, names[n], text.data, text.size, &again);
            CHECK((r == GSF_OK) == (n == t || (n == 4 && t != 1)));
            if (r == GSF_OK) CHECK(again.count == 7);
            else CHECK(r == GSF_ERROR_FORMAT && strncmp(ctx.error, names[n], strlen(names[n])) == 0);
            gsf_splat_destroy(&ctx, &again);
        }
        gsf_destroy_buffer(&ctx, &text);
    }
    CHECK_RESULT(&ctx, gsf_splat_save(&ctx, test_scratch("x.obj"), &s, NULL), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(&ctx, gsf_splat_load(&ctx, "no/such/file.spz", &again), GSF_ERROR_NOT_FOUND);
    CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "x", "", 0, &again), GSF_ERROR_FORMAT);
    CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "x", "NGSP\4\0\0\0", 8, &again), ZSTD ? GSF_ERROR_FORMAT : GSF_ERROR_UNSUPPORTED);
    if (!ZSTD) CHECK(strstr(ctx.error, "version 4") && strstr(ctx.error, "GSF_USE_ZSTD"));
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

// ---- damage --------------------------------------------------------------------

static void parse_damaged(gsf_context* ctx, const char* name, const void* data, size_t size, int may_pass) {
    gsf_splats s;
    const gsf_result r = gsf_splat_parse(ctx, name, data, size, &s);
    CHECK(is_refusal(r) || (may_pass && r == GSF_OK));
    if (r != GSF_OK) CHECK(strncmp(ctx->error, name, strlen(name)) == 0 && s.owned == NULL);
    gsf_splat_destroy(ctx, &s);
}

static void test_damage(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s = random_splats(&ctx, 3, 1, 1.0, 13);
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    CHECK_OK(&ctx, gsf_splat_format(&ctx, "x.spz", &s, NULL, &text));
    for (size_t cut = 0; cut < text.size; cut++) {
        unsigned char* part = (unsigned char*)exact_copy(text.data, cut);
        parse_damaged(&ctx, "cut.spz", part, cut, 0);
        free(part);
    }
    // An accepted flip must not change the splats: gzip's time and hints, bits after the last block, an equivalent distance.
    unsigned char* whole = (unsigned char*)exact_copy(text.data, text.size);
    gsf_splats sound, damaged;
    size_t passed = 0;
    CHECK_OK(&ctx, gsf_splat_parse(&ctx, "x.spz", whole, text.size, &sound));
    for (size_t at = 0; at < text.size; at++)
        for (int flip = 1; flip < 256; flip++) {
            whole[at] ^= (unsigned char)flip;
            const gsf_result r = gsf_splat_parse(&ctx, "flip.spz", whole, text.size, &damaged);
            if (r == GSF_OK) {
                passed++;
                CHECK(damaged.count == 3 && damaged.sh_degree == 1 && damaged.antialiased == sound.antialiased);
                CHECK(memcmp(damaged.means, sound.means, 36) == 0 && memcmp(damaged.quats, sound.quats, 48) == 0);
                CHECK(memcmp(damaged.log_scales, sound.log_scales, 36) == 0 && memcmp(damaged.sh, sound.sh, 144) == 0);
                CHECK(memcmp(damaged.opacity_logits, sound.opacity_logits, 12) == 0);
            } else {
                CHECK(is_refusal(r) && strncmp(ctx.error, "flip.spz:", 9) == 0 && damaged.owned == NULL);
            }
            gsf_splat_destroy(&ctx, &damaged);
            whole[at] ^= (unsigned char)flip;
        }
    CHECK(passed < 10 * 255);
    gsf_splat_destroy(&ctx, &sound);
    free(whole);
    // flips in the header and a few bytes of the content, with the checksum corrected
    for (int version = 1; version <= 3; version++) {
        unsigned char content[64];
        const size_t size = spz_by_hand_size[version - 1];
        for (size_t at = 0; at < size; at++)
            for (int flip = 1; flip < 256; flip += at < HEAD ? 1 : 63) {
                size_t file_size;
                memcpy(content, spz_by_hand[version - 1], size);
                content[at] ^= (unsigned char)flip;
                unsigned char* file = wrap(content, size, &file_size);
                unsigned char* exact = (unsigned char*)exact_copy(file, file_size);
                count.asked = 0;
                // fractional bits, flags other than "extensions", the reserved byte, and all values
                parse_damaged(&ctx, "head.spz", exact, file_size, at >= 13 || (version == 2 && at == 12));
                CHECK(count.asked < (GSF__DEFLATE_RATIO + 10) * file_size + 10000);
                free(exact);
                free(file);
            }
        for (size_t cut = 0; cut < size; cut++) {
            size_t file_size;
            unsigned char* file = wrap(spz_by_hand[version - 1], cut, &file_size);
            parse_damaged(&ctx, "short.spz", file, file_size, 0);
            free(file);
        }
    }
    gsf_destroy_buffer(&ctx, &text);
    CHECK_OK(&ctx, gsf_splat_format(&ctx, "x.splat", &s, NULL, &text));
    for (size_t cut = 0; cut < text.size; cut++) {
        unsigned char* part = (unsigned char*)exact_copy(text.data, cut);
        parse_damaged(&ctx, "cut.splat", part, cut, cut % 32 == 0);
        free(part);
    }
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

// A header that claims 4 billion splats, extensions (which are skipped), band 4.
static void test_claims(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    unsigned char content[200];
    size_t size;
    gsf_splats s;
    memset(content, 0, sizeof content);
    memcpy(content, spz_by_hand[1], spz_by_hand_size[1]);
    memset(content + 8, 255, 4);
    unsigned char* file = wrap(content, spz_by_hand_size[1], &size);
    CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "x.spz", file, size, &s), GSF_ERROR_FORMAT);
    CHECK(count.asked < 1000 && strstr(ctx.error, "4294967295 splats"));
    free(file);
    file = wrap(content, spz_by_hand_size[1], &size); // gzip's size field: 4 GB, then just above the limit
    memset(file + size - 4, 255, 4);
    count.asked = 0;
    CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "x.spz", file, size, &s), GSF_ERROR_FORMAT);
    const size_t most = GSF__DEFLATE_RATIO * (size - 18 + 1);
    for (int k = 0; k < 4; k++) file[size - 4 + (size_t)k] = (unsigned char)(most >> 8 * k);
    CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "x.spz", file, size, &s), GSF_ERROR_FORMAT);
    CHECK(count.asked == 0 && strstr(ctx.error, "bytes of content claimed"));
    free(file);
    memset(content + 8, 0, 4);
    content[8] = 1;
    content[14] = 2;
    file = wrap(content, spz_by_hand_size[1] + 20, &size);
    CHECK_OK(&ctx, gsf_splat_parse(&ctx, "x.spz", file, size, &s));
    CHECK(s.count == 1 && warnings == 1 && strstr(warning, "20 bytes of extensions") && s.log_scales[0] == -5.0f);
    gsf_splat_destroy(&ctx, &s);
    content[14] = 0; // the same bytes without the flag
    free(file);
    file = wrap(content, spz_by_hand_size[1] + 20, &size);
    CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "x.spz", file, size, &s), GSF_ERROR_FORMAT);
    free(file);
    content[12] = 4;
    file = wrap(content, HEAD + 19 + 72, &size);
    CHECK_OK(&ctx, gsf_splat_parse(&ctx, "x.spz", file, size, &s));
    CHECK(s.sh_degree == 3 && strstr(warning, "band 4"));
    CHECK_NEAR(s.sh[3], 0.25, 0);
    gsf_splat_destroy(&ctx, &s);
    free(file);
    CHECK(count.live == 0);
}

static void test_out_of_memory(void) {
    static const char* const names[3] = {"x.splat", "x.spz", "x.glb"};
    for (int f = 0; f < 3; f++)
        for (int reading = 0; reading < 2; reading++)
            for (size_t k = 1;; k++) {
                counter count;
                gsf_context ctx = make_context(&count, 0);
                gsf_splats s = random_splats(&ctx, 50, 1, 1.0, 17), again;
                gsf_buffer text;
                memset(&text, 0, sizeof text);
                memset(&again, 0, sizeof again);
                s.means[0] = NAN; // so that rows are dropped
                if (!reading) count.fail_at = count.calls + k;
                gsf_result r = gsf_splat_format(&ctx, names[f], &s, NULL, &text);
                if (reading) {
                    count.fail_at = count.calls + k;
                    r = gsf_splat_parse(&ctx, names[f], text.data, text.size, &again);
                }
                const int expected = CHECK(r == GSF_OK || (r == GSF_ERROR_OUT_OF_MEMORY && again.owned == NULL));
                gsf_destroy_buffer(&ctx, &text);
                gsf_splat_destroy(&ctx, &again);
                gsf_splat_destroy(&ctx, &s);
                CHECK(count.live == 0);
                if (r == GSF_OK) CHECK(k >= 3);
                if (r == GSF_OK || !expected) break;
            }
}

// ---- gzip ----------------------------------------------------------------------

static void check_gzip(gsf_context* ctx, const unsigned char* data, size_t size, double most) {
    gsf_buffer text;
    size_t back_size;
    memset(&text, 0, sizeof text);
    CHECK_OK(ctx, gsf__gzip_append(ctx, "data", data, size, &text));
    unsigned char* back = unwrap(ctx, text.data, text.size, &back_size);
    CHECK(back_size == size && memcmp(back, data, size) == 0);
    CHECK((double)text.size <= most * (double)size + 40);
    gsf_free(ctx, back);
    gsf_destroy_buffer(ctx, &text);
}

static void test_gzip(void) {
    counter count;
    gsf_context ctx = make_context(&count, 0);
    const size_t room = 300000;
    unsigned char* data = (unsigned char*)calloc(room, 1);
    uint64_t seed = 23;
    check_gzip(&ctx, data, room, 0.01);
    for (size_t i = 0; i < room; i++) data[i] = (unsigned char)test_random_bits(&seed);
    check_gzip(&ctx, data, room, 1.001); // stored
    for (size_t size = 1; size < 300; size++) check_gzip(&ctx, data, size, 1.0);
    for (size_t i = 0; i < room; i++) // matches of all lengths and distances
        data[i] = i < 40000 || i % 701 < 9 ? data[i] : data[i - 1 - (i / 701 * 97) % 33000];
    check_gzip(&ctx, data, room, 0.9);
    free(data);
    // From zlib 1.2.13: a block with dynamic Huffman codes, after a header with name, comment, extra field and checksum
    static const unsigned char zlib_body[] = {
        45, 146, 89, 146, 197, 32, 12, 3, 19, 192, 236, 102, 199, 64, 222, 253, 239, 57, 206, 84, 196, 127, 151, 218,
        226, 186, 174, 91, 72, 48, 46, 164, 58, 110, 112, 216, 46, 8, 245, 210, 56, 84, 28, 128, 100, 171, 74, 119, 32,
        63, 61, 133, 11, 101, 49, 51, 202, 230, 69, 11, 106, 36, 43, 70, 246, 112, 143, 130, 222, 40, 113, 205, 209,
        91, 229, 180, 62, 230, 37, 148, 241, 88, 152, 232, 243, 144, 46, 79, 136, 93, 134, 174, 62, 96, 92, 129, 194,
        138, 34, 67, 115, 43, 233, 137, 48, 147, 185, 91, 212, 119, 79, 94, 139, 217, 114, 244, 86, 43, 41, 238, 55,
        66, 42, 109, 125, 204, 109, 10, 237, 83, 191, 117, 108, 183, 73, 19, 112, 234, 180, 92, 131, 44, 226, 226, 183,
        241, 227, 193, 136, 106, 160, 166, 226, 21, 213, 104, 36, 49, 206, 105, 37, 22, 113, 69, 206, 152, 180, 132,
        210, 142, 137, 36, 77, 172, 164, 124, 161, 207, 248, 3, 226, 254, 7, 202, 162, 187, 223, 217, 80, 210, 148,
        173, 100, 101, 57, 75, 180, 106, 141, 154, 222, 134, 160, 228, 27, 5, 111, 63, 62, 224, 82, 54, 150, 41, 109,
        98, 231, 178, 76, 94, 182, 156, 48, 12, 43, 31, 220, 120, 210, 199, 251, 132, 87, 13, 176, 26, 50, 174, 191,
        39, 4, 185, 23, 209, 228, 208, 218, 135, 149, 223, 73, 54, 184, 212, 55, 27, 111, 155, 73, 39, 50, 31, 48, 63,
        233, 164, 135, 125, 237, 140, 79, 117, 187, 216, 93, 189, 154, 217, 177, 50, 58, 216, 124, 66, 12, 206, 112,
        195, 55, 160, 121, 96, 228, 3, 50, 14, 235, 2, 246, 133, 208, 142, 171, 199, 183, 31, 146, 235, 186, 252, 242,
        147, 127, 229, 227, 217, 149, 205, 42, 238, 116, 52, 135, 55, 214, 231, 93, 196, 25, 120, 206, 91, 145, 222,
        126, 15, 255, 153, 119, 146, 163, 121, 225, 99, 176, 159, 207, 184, 62, 113, 218, 246, 7, 211, 171, 119, 208,
        88, 2, 0, 0};
    unsigned char file[64 + sizeof zlib_body];
    static const unsigned char head[] = {0x1f, 0x8b, 8, 0x1e, 1,   2, 3,   4,   2, 3, 3,
                                         0,    'e',  'x', 't', 'n', 0, 'c', 'd', 0, 9, 9};
    memcpy(file, head, sizeof head);
    memcpy(file + sizeof head, zlib_body, sizeof zlib_body);
    size_t size, whole = sizeof head + sizeof zlib_body;
    unsigned char* content = unwrap(&ctx, file, whole, &size);
    CHECK(size == 600);
    for (size_t i = 0; i < size; i++) CHECK(content[i] == (unsigned char)((i * i / 7) % 23 + i / 100));
    gsf_free(&ctx, content);
    // Invalid streams give an error for any claimed content size, without any access out of bounds.
    static const struct { const char* bytes; size_t size; } bad[] = {
        {"\7\0\0", 3},                         // block of unknown type
        {"\1\1\0\0\0x", 6},                   // stored block with inconsistent LEN and NLEN
        {"\1\5\0\xfa\xffxy", 7},             // truncated
        {"\x63\x00\x42\x00\x00", 5},         // match before the start of the output
        {"\xf5\xff\xff\xff", 4},             // too many codes
        {"\5\0\xfe\xff\xff\xff\xff\xff", 8}, // code lengths that do not form a prefix code
        {"\5\0", 2},                           // truncated
        {"", 0},
    };
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++)
        for (unsigned claimed = 1; claimed <= 600; claimed += claimed < 40 ? 1 : 70) {
            const size_t bad_size = 10 + bad[i].size + 8;
            size_t bad_content_size;
            unsigned char *exact = (unsigned char*)calloc(bad_size, 1), *bad_content;
            memcpy(exact, "\x1f\x8b\10", 3);
            memcpy(exact + 10, bad[i].bytes, bad[i].size);
            exact[bad_size - 4] = (unsigned char)(claimed & 255);
            exact[bad_size - 3] = (unsigned char)(claimed >> 8);
            CHECK_RESULT(&ctx, gsf__gzip_read(&ctx, "bad", exact, bad_size, &bad_content, &bad_content_size),
                         GSF_ERROR_FORMAT);
            CHECK(!bad_content && bad_content_size == 0 && strncmp(ctx.error, "bad:", 4) == 0);
            free(exact);
        }
    CHECK(count.live == 0);
}

// ---- glTF ----------------------------------------------------------------------

// A GLB file of a JSON text and arrays; freed by the caller.
static unsigned char* glb_of(const char* json, const void* arrays, size_t array_size, size_t* size) {
    const size_t text = strlen(json), padded = (text + 3) / 4 * 4;
    *size = 28 + padded + array_size;
    unsigned char* p = (unsigned char*)malloc(*size);
    const uint32_t words[3] = {(uint32_t)*size, (uint32_t)padded, (uint32_t)array_size};
    memcpy(p, "glTF\2\0\0\0....", 12);
    memcpy(p + 16, "JSON", 4);
    memset(p + 20, ' ', padded);
    memcpy(p + 20, json, text);
    memcpy(p + 24 + padded, "BIN", 4);
    memcpy(p + 28 + padded, arrays, array_size);
    for (int k = 0; k < 12; k++) {
        unsigned char* at = k < 4 ? p + 8 + k : k < 8 ? p + 12 + k - 4 : p + 20 + padded + (size_t)k - 8;
        *at = (unsigned char)(words[k / 4] >> 8 * (k % 4));
    }
    return p;
}

#define GLB_NODES "{\"asset\":{\"version\":\"2.0\"},\"scene\":1,\"scenes\":[{},{\"nodes\":[1]}],\"nodes\":["
#define GLB_REST "]," \
    "\"meshes\":[{\"primitives\":[{\"mode\":4,\"attributes\":{\"POSITION\":9}},{\"mode\":0,\"attributes\":{" \
    "\"POSITION\":0,\"KHR_gaussian_splatting:ROTATION\":1,\"KHR_gaussian_splatting:SCALE\":2," \
    "\"KHR_gaussian_splatting:OPACITY\":3,\"KHR_gaussian_splatting:SH_DEGREE_0_COEF_0\":4}," \
    "\"extensions\":{\"KHR_gaussian_splatting\":{\"kernel\":\"ellipse\",\"colorSpace\":\"srgb_rec709_display\"}}}]}]," \
    "\"accessors\":[{\"bufferView\":0,\"componentType\":5126,\"count\":2,\"type\":\"VEC3\"}," \
    "{\"bufferView\":0,\"byteOffset\":12,\"componentType\":5122,\"normalized\":true,\"count\":2,\"type\":\"VEC4\"}," \
    "{\"bufferView\":0,\"byteOffset\":20,\"componentType\":5123,\"count\":2,\"type\":\"VEC3\"}," \
    "{\"bufferView\":0,\"byteOffset\":26,\"componentType\":5121,\"normalized\":true,\"count\":2,\"type\":\"SCALAR\"}," \
    "{\"bufferView\":1,\"componentType\":5126,\"count\":2,\"type\":\"VEC3\"}]," \
    "\"bufferViews\":[{\"buffer\":0,\"byteLength\":56,\"byteStride\":28},{\"buffer\":0,\"byteOffset\":56,\"byteLength\":24}]," \
    "\"buffers\":[{\"byteLength\":80}]}"
#define GLB_TREE "{\"mesh\":0,\"rotation\":[0,0,0.70710678118654757,0.70710678118654757]}," \
    "{\"children\":[0],\"translation\":[10,20,30],\"scale\":[2,2,2]}"

// Two splats, interleaved: position f32 x 3 | rotation i16 x 4 | scale u16 x 3 | opacity u8 | unused; then colours.
static void glb_arrays(unsigned char out[80]) {
    const float positions[2][3] = {{1.0f, 2.0f, 3.0f}, {0.0f, 0.0f, 0.0f}}, colors[6] = {1, 2, 3, 4, 5, 6};
    const int16_t turn[4] = {0, 0, 32767, 0}; // half a turn about z
    const uint16_t scales[3] = {1, 2, 4};
    memset(out, 0, 80);
    for (int i = 0; i < 2; i++) {
        memcpy(out + 28 * i, positions[i], 12);
        memcpy(out + 28 * i + 12, turn, 8);
        memcpy(out + 28 * i + 20, scales, 6);
        out[28 * i + 26] = i ? 255 : 51;
    }
    memcpy(out + 56, colors, 24);
}

static void test_glb(void) { // nodes in nodes, other component types, files of early writers, refusals
    counter count;
    gsf_context ctx = make_context(&count, 0);
    unsigned char arrays[80];
    size_t size;
    gsf_splats s;
    glb_arrays(arrays);
    unsigned char* file = glb_of(GLB_NODES GLB_TREE GLB_REST, arrays, sizeof arrays, &size);
    if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "tree.glb", file, size, &s))) {
        CHECK(s.count == 2 && s.sh_degree == 0 && warnings == 0);
        // (1,2,3), turned by 90 degrees about z: (-2,1,3); doubled and moved: (6,22,36); x and y negated
        const double at[6] = {-6.0, -22.0, 36.0, -10.0, -20.0, 30.0};
        for (int k = 0; k < 6; k++) CHECK_NEAR(s.means[k], at[k], 1e-5);
        for (int k = 0; k < 3; k++) CHECK_NEAR(s.log_scales[k], log(2.0 * (1 << k)), 1e-6);
        CHECK_NEAR(fabsf(s.quats[0]), sqrt(0.5), 1e-6); // 180 + 90 degrees about z, which x and y negated leave alone
        CHECK_NEAR(fabsf(s.quats[3]), sqrt(0.5), 1e-6);
        CHECK(s.quats[0] * s.quats[3] < 0.0f);
        CHECK_NEAR(sigmoid((double)s.opacity_logits[0]), 0.2, 1e-6);
        CHECK_NEAR(sigmoid((double)s.opacity_logits[1]), 0.999, 1e-4);
        for (int k = 0; k < 6; k++) CHECK(s.sh[k] == (float)(k + 1));
        gsf_splat_destroy(&ctx, &s);
    }
    free(file);
    static const struct { const char *nodes, *error; gsf_result result; } bad[] = {
        {"{},{\"children\":[1]}", "no tree", GSF_ERROR_FORMAT},
        {"{\"mesh\":0},{\"children\":[0,0]}", "no tree", GSF_ERROR_FORMAT},
        {"{\"mesh\":1},{\"children\":[0]}", "\"mesh\" is not", GSF_ERROR_FORMAT},
        {"{\"mesh\":0},{\"children\":[7]}", "index of a node", GSF_ERROR_FORMAT},
        {"{\"mesh\":0},{}", "has no splats", GSF_ERROR_FORMAT},
        {"{\"mesh\":0},{\"children\":[0],\"scale\":[1,1,2]}", "stretches", GSF_ERROR_UNSUPPORTED},
        {"{\"mesh\":0},{\"children\":[0],\"scale\":[1,1,-1]}", "mirrors", GSF_ERROR_UNSUPPORTED},
        {"{\"mesh\":0},{\"children\":[0],\"scale\":[1,1]}", "as many numbers", GSF_ERROR_FORMAT},
        {"{\"mesh\":0},{\"children\":[0],\"matrix\":[1,0,0,0,0,1,0,0,0,0,1,0,\"x\",0,0,1]}", "not a number", GSF_ERROR_FORMAT},
    };
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        char json[4096];
        snprintf(json, sizeof json, "%s%s%s", GLB_NODES, bad[i].nodes, GLB_REST);
        file = glb_of(json, arrays, sizeof arrays, &size);
        CHECK_RESULT(&ctx, gsf_splat_parse(&ctx, "bad.glb", file, size, &s), bad[i].result);
        CHECK(strstr(ctx.error, bad[i].error) && strncmp(ctx.error, "bad.glb:", 8) == 0 && !s.owned);
        free(file);
    }
    file = glb_of(GLB_NODES "{\"mesh\":0},{\"mesh\":0,\"children\":[0]}" GLB_REST, arrays, sizeof arrays, &size); // twice
    CHECK_OK(&ctx, gsf_splat_parse(&ctx, "two.glb", file, size, &s));
    CHECK(s.count == 4 && memcmp(s.means, s.means + 6, 6 * sizeof(float)) == 0);
    gsf_splat_destroy(&ctx, &s);
    free(file);
    CHECK(count.live == 0 && warnings == 0);
    // logarithms of scales and logits of opacities, as written before the extension was ratified
    s = random_splats(&ctx, 20, 1, 1.0, 23);
    gsf_splats early;
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    CHECK_OK(&ctx, gsf_splat_format(&ctx, "x.glb", &s, NULL, &text));
    unsigned char* scales = (unsigned char*)text.data + text.size - 20 * (8 + 48 + 4 + 12);
    for (size_t i = 0; i < 60; i++) gsf__put_f32(scales + 4 * i, s.log_scales[i]);
    for (size_t i = 0; i < 20; i++) gsf__put_f32(scales + 240 + 4 * i, s.opacity_logits[i]);
    if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "early.glb", text.data, text.size, &early))) {
        CHECK(warnings == 2 && memcmp(early.log_scales, s.log_scales, 240) == 0);
        CHECK(memcmp(early.opacity_logits, s.opacity_logits, 80) == 0);
        gsf_splat_destroy(&ctx, &early);
    }
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &s);
    CHECK_OK(&ctx, gsf_splat_make(&ctx, 0, 0, &s));
    CHECK_RESULT(&ctx, gsf_splat_format(&ctx, "none.glb", &s, NULL, &text), GSF_ERROR_DEGENERATE);
    gsf_destroy_buffer(&ctx, &text);
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

static void test_glb_origin(void) { // is kept, as the node's translation; with `local` it is not written
    counter count;
    gsf_context ctx = make_context(&count, 0);
    gsf_splats s = random_splats(&ctx, 300, 0, 3.0, 9), again;
    s.origin[0] = 4512345.0;
    s.origin[2] = 5400000.25;
    for (int local = 0; local < 2; local++) {
        const gsf_splat_save_desc desc = {GSF_SPLAT_AUTO, local, 0};
        gsf_buffer text;
        double worst = 0.0;
        memset(&text, 0, sizeof text);
        CHECK_OK(&ctx, gsf_splat_format(&ctx, "far.glb", &s, &desc, &text));
        if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "far.glb", text.data, text.size, &again))) {
            for (size_t i = 0; i < 3 * s.count; i++)
                worst = fmax(worst, fabs(again.origin[i % 3] - (local ? 0.0 : s.origin[i % 3]) + again.means[i] - s.means[i]));
            CHECK(worst <= (local ? 0.0 : 1e-6));
            gsf_splat_destroy(&ctx, &again);
        }
        gsf_destroy_buffer(&ctx, &text);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0 && warnings == 0);
}

static void test_glb_damage(void) { // cut anywhere; any byte of header and JSON changed
    counter count;
    gsf_context ctx = make_context(&count, 0);
    unsigned char arrays[80];
    size_t size;
    glb_arrays(arrays);
    unsigned char* file = glb_of(GLB_NODES GLB_TREE GLB_REST, arrays, sizeof arrays, &size);
    for (size_t cut = 0; cut < size; cut++) {
        unsigned char* part = (unsigned char*)exact_copy(file, cut);
        parse_damaged(&ctx, "cut.glb", part, cut, 0);
        free(part);
    }
    for (size_t at = 0; at < size; at++)
        for (int flip = 1; flip < 256; flip += at < 20 ? 1 : 37) {
            file[at] ^= (unsigned char)flip;
            unsigned char* whole = (unsigned char*)exact_copy(file, size);
            parse_damaged(&ctx, "flip.glb", whole, size, 1);
            free(whole);
            file[at] ^= (unsigned char)flip;
        }
    free(file);
    CHECK(count.live == 0);
}

int main(void) {
    test_splat_by_hand();
    test_spz_by_hand();
    test_official();
    test_official_4();
    test_round_trips();
    test_background();
    test_workers();
    test_format_not_finite();
    test_extent();
    test_types();
    test_damage();
    test_claims();
    test_out_of_memory();
    test_glb();
    test_glb_origin();
    test_glb_damage();
    test_gzip();
    return test_report();
}
