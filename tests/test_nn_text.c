// The text half of the restorer: tokenizer and T5 encoder on synthetic and golden models; damaged files, unusual texts,
// out of memory, workers, cancellation. (golden_restorer compares with transformers.)
//
//     test_nn_text --tokenize FOLDER    reads texts from stdin, each a 32-bit size and as many bytes, and prints the ids of
//                                       each on a line: what tests/compare_tokenizer.py runs
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "made_spiece.h"
#include "test.h"
#include "test_hooks.h"

static gsf_context ctx;
static uint64_t text_seed = 11;

// ---- tokenizer: expected ids --------------------------------------------------------

static gsf_result open_made(gsf_context* c, int flags, gsf_nn_tokenizer* t) {
    made_bytes m;
    made_spiece(flags, &m);
    return gsf__nn_parse_tokenizer(c, "made", m.data, m.size, NULL, 0, t);
}

// ids: those of the text without </s>.
static void expect_ids(int flags, const char* text, size_t size, const int32_t* ids, size_t count) {
    gsf_nn_tokenizer t;
    int32_t got[64];
    size_t n = 0;
    if (!CHECK_OK(&ctx, open_made(&ctx, flags, &t))) return;
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, text, size, got, 64, &n));
    int same = n == count + 1 && got[count] == t.end_id;
    for (size_t i = 0; i < count; i++) same &= got[i] == ids[i];
    for (size_t i = count + 1; i < 64; i++) same &= got[i] == t.pad_id;
    if (!CHECK(same)) {
        fprintf(stderr, "    \"%s\" (flags %d):", text, flags);
        for (size_t i = 0; i < n && i < 64; i++) fprintf(stderr, " %d", (int)got[i]);
        fprintf(stderr, "\n");
    }
    gsf_nn_destroy_tokenizer(&ctx, &t);
}

static void test_made(void) {
    static const struct { int flags; const char* text; size_t count; int32_t ids[12]; } cases[] = {
        {0, "", 0, {0}},
        {0, "   ", 0, {0}},
        {0, "ab", 1, {8}},                   // the piece of score -5 beats two of -3
        {0, "  ab \t ab  ", 2, {8, 8}},      // spaces of the text and those that the map produces
        {0, "a", 2, {3, 4}},
        {0, "abc", 2, {8, 6}},
        {0, "A", 4, {3, 5, 3, 6}},           // mapped to "b c"
        {0, "QQa", 2, {3, 4}},               // Q is mapped to nothing
        {0, "Q", 0, {0}},                    // the remaining prefix is removed, too
        {0, "xyz", 2, {3, 2}},               // a run of unknown characters is one token
        {0, "xuz", 2, {3, 2}},
        {0, "u", 2, {3, 11}},                // segmentation skips unused pieces, but the text equals one
        {0, "xayb", 5, {3, 2, 4, 2, 5}},
        {0, "[K]a[K]", 4, {3, 10, 4, 10}},
        {0, "[K", 2, {3, 2}},
        {0, "\xe4\xb8\xad\xe4\xb8\xad", 3, {3, 12, 12}},
        {0, "\xe2\x96\x81" "ab", 2, {3, 8}}, // a literal U+2581 is a space as well
        {MADE_NO_PREFIX, "ab ab", 2, {7, 8}},
        {MADE_NO_TRIM, " ab", 2, {3, 8}},
        {MADE_NO_TRIM, "  a ", 5, {3, 3, 3, 4, 3}},
        {MADE_NO_ESCAPE, "a b", 4, {13, 4, 13, 5}},
        {MADE_SUFFIX, "ab", 2, {7, 3}},
        {MADE_NO_MAP, "A\t", 2, {3, 2}},
        {MADE_BYTES, "xa", 3, {3, 14 + 'x', 4}},
        {MADE_BYTES, "\xc3\xa9", 3, {3, 14 + 0xc3, 14 + 0xa9}},
        // Added tokens: pieces never extend across them, and each stretch between them has its own prefix.
        {0, "ab<pad>ab", 3, {8, 0, 8}},
        {0, "<pad></s><unk>", 3, {0, 1, 2}},
        {0, "ab <extra_id_0> ab", 3, {8, 113, 8}},
        {0, "a \xe3\x80\x80<extra_id_99>\xc2\xa0\x1c", 3, {3, 4, 14}},
        {0, "<extra_id_1", 3, {3, 2, 0}},
        {0, "<<pad>", 3, {3, 2, 0}},
    };
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        size_t count = cases[i].count;
        int32_t ids[12];
        memcpy(ids, cases[i].ids, sizeof ids);
        if (strcmp(cases[i].text, "<extra_id_1") == 0) count = 4, ids[2] = 4, ids[3] = 2; // the "a" in the middle
        expect_ids(cases[i].flags, cases[i].text, strlen(cases[i].text), ids, count);
    }
    static const int32_t zero[] = {3, 4, 2, 5}, malformed[] = {3, 4, 2, 5};
    expect_ids(0, "a\0b", 3, zero, 4);
    expect_ids(0, "a\xff\xe4\xb8" "b", 5, malformed, 4);
}

static void test_room(void) {
    gsf_nn_tokenizer t;
    int32_t ids[8];
    size_t count = 0;
    if (!CHECK_OK(&ctx, open_made(&ctx, 0, &t))) return;
    CHECK(t.piece_count == 14 && t.id_count == 114 && t.pad_id == 0 && t.end_id == 1 && t.unknown_id == 2);
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, "ababab", 6, NULL, 0, &count));
    CHECK(count == 4);
    for (size_t room = 1; room <= 8; room++) {
        for (int i = 0; i < 8; i++) ids[i] = -7;
        CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, "ababab", 6, ids, room, NULL));
        for (size_t i = 0; i < 8; i++) {
            const size_t kept = room < 4 ? room - 1 : 3;
            CHECK(ids[i] == (i >= room ? -7 : i < kept ? (i ? 7 : 8) : i == kept ? t.end_id : t.pad_id));
        }
    }
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, "ab</s>", 6, ids, 8, &count)); // </s> is not added twice
    CHECK(count == 2 && ids[0] == 8 && ids[1] == 1 && ids[2] == 0);
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, "ab</s>ab", 8, ids, 3, &count)); // nor when the text is truncated there
    CHECK(count == 4 && ids[0] == 8 && ids[1] == 1 && ids[2] == 0);
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, NULL, 0, ids, 2, &count));
    CHECK(count == 1 && ids[0] == 1 && ids[1] == 0);
    gsf_nn_destroy_tokenizer(&ctx, &t);
    gsf_nn_destroy_tokenizer(&ctx, &t); // destroying twice is allowed
}

// ---- tokenizer: unusual texts -------------------------------------------------------

static void check_tokens(const gsf_nn_tokenizer* t, const char* text, size_t size) {
    size_t count = 0;
    int32_t padded[226];
    char* exact = (char*)malloc(size ? size : 1); // so that a sanitizer detects a read past the end
    memcpy(exact, text, size);
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, t, exact, size, padded, 226, &count));
    int32_t* all = (int32_t*)malloc(count * sizeof *all);
    size_t again = 0;
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, t, exact, size, all, count, &again));
    int ok = count > 0 && again == count && count <= 40 * size + 2 && all[count - 1] == t->end_id;
    for (size_t i = 0; i < count; i++) ok &= all[i] >= 0 && all[i] < t->id_count;
    for (size_t i = 0; i < 225; i++) ok &= padded[i] == (i < count ? all[i] : t->pad_id);
    ok &= count < 226 || padded[224] == t->end_id || padded[225] == t->end_id;
    CHECK(ok);
    free(exact);
    free(all);
}

static void test_odd_t5_texts(const gsf_nn_tokenizer* t) {
    static const char* const texts[] = {
        "", "\xf0\x9f\x98\x80\xf0\x9f\x9a\x80", "\xf0\x9f\x91\xa9\xe2\x80\x8d\xf0\x9f\x91\xa7", "\x01\x02\x7f\r\n\v",
        "\xff\xfe\xfd", "\xe2\x96", "\xf4\x90\x80\x80", "\xed\xa0\x80", "\xc0\x80", "e\xcc\x81\xcc\x81\xcc\x81",
        "\xef\xbb\xbf", "\xe2\x80\xae", "<extra_id_0><extra_id_0>", "<extra_id_", "<pad", "\xef\xb7\xba\xef\xb7\xba"};
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++) check_tokens(t, texts[i], strlen(texts[i]));
    char bytes[200];
    for (int round = 0; round < 300; round++) {
        const size_t size = (size_t)(test_random(&text_seed) * 200);
        const int kind = round % 3;
        for (size_t i = 0; i < size; i++) {
            const uint64_t bits = test_random_bits(&text_seed);
            bytes[i] = kind == 0 ? (char)bits : kind == 1 ? (char)(bits % 95 + 32) : "\xe2\x96\x81 <a>/s"[bits % 9];
        }
        check_tokens(t, bytes, size);
    }
}

// A megabyte of the same few characters: neither time per byte nor memory per byte may grow.
static void test_long_texts(const char* folder) {
    static const char* const units[] = {"a", " ", "The video ", "<", "<pad>x", "\xf0\x9f\x98\x80", "\xff", "\xef\xb7\xba"};
    enum { SIZE = 1 << 20 };
    char* text = (char*)malloc(SIZE);
    for (size_t k = 0; k < sizeof units / sizeof units[0]; k++) {
        const size_t unit = strlen(units[k]), size = SIZE / unit * unit;
        gsf_context counted;
        gsf_nn_tokenizer t;
        counter memory;
        size_t count = 0;
        memset(&memory, 0, sizeof memory);
        test_context_zero(&counted);
        count_memory(&counted, &memory);
        CHECK_OK(&counted, gsf_init_context(&counted));
        if (!CHECK_OK(&counted, gsf_nn_load_tokenizer(&counted, folder, &t))) break;
        memory.asked = 0;
        for (size_t i = 0; i < size; i++) text[i] = units[k][i % unit];
        CHECK_OK(&counted, gsf_nn_encode_text(&counted, &t, text, size, NULL, 0, &count));
        CHECK(count > 0 && count <= 40 * size + 2 && memory.asked < (size_t)SIZE * 800); // U+FDFA becomes 18 characters
        gsf_nn_destroy_tokenizer(&counted, &t);
        CHECK(memory.live == 0);
    }
    free(text);
}

// ---- tokenizer: damaged files -------------------------------------------------------

static int accepted, refused;

// Opens the bytes in a block of exactly their size; a model that is accepted must work.
static void try_model(const unsigned char* data, size_t size) {
    gsf_nn_tokenizer t;
    unsigned char* exact = (unsigned char*)malloc(size ? size : 1);
    if (size) memcpy(exact, data, size);
    const gsf_result result = gsf__nn_parse_tokenizer(&ctx, "bad.model", exact, size, NULL, 0, &t);
    free(exact);
    if (result == GSF_OK) {
        static const char text[] = "ab A\tu[K] \xe4\xb8\xad xyz</s> The video";
        accepted++;
        check_tokens(&t, text, sizeof text - 1);
    } else {
        refused++;
        CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED);
        CHECK(strncmp(ctx.error, "bad.model:", 10) == 0 && !strchr(ctx.error, '\n') && t.model == NULL);
    }
    gsf_nn_destroy_tokenizer(&ctx, &t);
}

static void test_bad_made(void) {
    made_bytes m, changed;
    made_spiece(0, &m);
    for (size_t size = 0; size < m.size; size++) try_model(m.data, size);
    for (size_t i = 0; i < m.size; i++) {
        static const unsigned char flips[] = {1, 2, 4, 128, 255};
        if (i > 300 && i + 300 < m.size && i % 5) continue; // most of the file is empty units of the map
        for (size_t k = 0; k < sizeof flips; k++) {
            changed = m;
            changed.data[i] ^= flips[k];
            try_model(changed.data, changed.size);
        }
    }
    CHECK(accepted > 0 && refused > (int)m.size / 2);
}

static void test_bad_golden(const char* folder) {
    char path[1200];
    size_t size;
    snprintf(path, sizeof path, "%s/spiece.model", folder);
    unsigned char* data = (unsigned char*)test_read_file(path, &size);
    for (int i = 0; i < 40; i++) try_model(data, (size_t)(test_random(&text_seed) * (double)size));
    for (int i = 0; i < 60; i++) {
        const size_t at = (size_t)(test_random(&text_seed) * (double)size);
        const unsigned char kept = data[at];
        data[at] ^= (unsigned char)(1 + test_random_bits(&text_seed) % 255);
        try_model(data, size);
        data[at] = kept;
    }
    free(data);
    unsigned char noise[512];
    for (int i = 0; i < 500; i++) {
        const size_t n = (size_t)(test_random(&text_seed) * sizeof noise);
        for (size_t k = 0; k < n; k++) noise[k] = (unsigned char)test_random_bits(&text_seed);
        try_model(noise, n);
    }
}

// One fault at a time, each with its own error message.
static void expect_refused(const made_bytes* m, gsf_result wanted, const char* words) {
    gsf_nn_tokenizer t;
    CHECK_RESULT(&ctx, gsf__nn_parse_tokenizer(&ctx, "bad.model", m->data, m->size, NULL, 0, &t), wanted);
    if (!CHECK(strstr(ctx.error, words) != NULL)) fprintf(stderr, "    \"%s\" has no \"%s\"\n", ctx.error, words);
    gsf_nn_destroy_tokenizer(&ctx, &t);
}

static void test_refusals(void) {
    made_bytes m, part;
    char text[1200];
    memset(text, 'a', sizeof text);
    text[1025] = 0;
    const struct { const char* text; float score; int type; const char* words; } pieces[] = {
        {"ab", 0, 1, "same text"}, {"", 0, 1, "has 0 bytes"}, {"d", NAN, 1, "score"}, {"d", INFINITY, 1, "score"},
        {"d", 0, 9, "type 9"}, {"d", 0, 2, "both of type unknown"}, {"<0x1g>", 0, 6, "not of the form"},
        {"\xff", 0, 1, "UTF-8"}, {text, 0, 1, "longer than"}};
    for (size_t i = 0; i < sizeof pieces / sizeof pieces[0]; i++) {
        made_spiece(0, &m);
        made_piece(&m, pieces[i].text, pieces[i].score, pieces[i].type);
        expect_refused(&m, GSF_ERROR_FORMAT, pieces[i].words);
    }
    for (int kind = 2; kind <= 4; kind++) { // BPE, words, characters
        made_spiece(0, &m);
        part.size = 0;
        made_varint(&part, 3, (uint64_t)kind);
        made_field(&m, 2, part.data, part.size);
        expect_refused(&m, GSF_ERROR_UNSUPPORTED, "is not unigram");
    }
    made_spiece(0, &m);
    part.size = 0;
    made_varint(&part, 35, 1); // byte fallback without byte pieces
    made_field(&m, 2, part.data, part.size);
    expect_refused(&m, GSF_ERROR_FORMAT, "byte 0");
    made_spiece(0, &m);
    made_varint(&m, 1, 5);
    expect_refused(&m, GSF_ERROR_FORMAT, "wire type 0");
    made_spiece(0, &m);
    made_number(&m, 1 << 3 | 3);
    expect_refused(&m, GSF_ERROR_FORMAT, "wire type 3");
    m.size = 0;
    made_piece(&m, "a", 0, 1);
    expect_refused(&m, GSF_ERROR_FORMAT, "no piece is of type unknown");
    made_piece(&m, "<unk>", 0, 2);
    expect_refused(&m, GSF_ERROR_FORMAT, "</s>");
}

// ---- tokenizer: folders and configs ---------------------------------------------------

static void write_file(const char* name, const void* data, size_t size) {
    CHECK_OK(&ctx, gsf_write_file(&ctx, test_scratch(name), data, size));
}

static void test_tokenizer_configs(void) {
    made_bytes m;
    gsf_nn_tokenizer t;
    int32_t ids[4];
    made_spiece(0, &m);
    write_file("spiece.model", m.data, m.size);
    remove(test_scratch("tokenizer_config.json"));
    remove(test_scratch("added_tokens.json"));
    CHECK_OK(&ctx, gsf_nn_load_tokenizer(&ctx, test_scratch("."), &t)); // T5's 100 extra ids
    CHECK(t.id_count == 114);
    gsf_nn_destroy_tokenizer(&ctx, &t);
    static const char list[] = "{\"<extra_id_0>\": 200, \"[one]\": 7}";
    write_file("added_tokens.json", list, sizeof list - 1);
    CHECK_OK(&ctx, gsf_nn_load_tokenizer(&ctx, test_scratch("."), &t));
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, "[one]<extra_id_0><extra_id_1>", 29, ids, 4, NULL));
    CHECK(t.id_count == 201 && ids[0] == 7 && ids[1] == 200 && ids[2] == 112 && ids[3] == 1);
    gsf_nn_destroy_tokenizer(&ctx, &t);
    static const char config[] = "{\"extra_ids\": 2, \"eos_token\": {\"content\": \"[end]\"}, \"pad_token\": \"</s>\","
                                 "\"added_tokens_decoder\": {\"40\": {\"content\": \"[end]\", \"rstrip\": true}}}";
    write_file("tokenizer_config.json", config, sizeof config - 1);
    CHECK_OK(&ctx, gsf_nn_load_tokenizer(&ctx, test_scratch("."), &t));
    CHECK_OK(&ctx, gsf_nn_encode_text(&ctx, &t, "<extra_id_0>", 12, ids, 4, NULL));
    CHECK(t.id_count == 41 && ids[0] == 15 && ids[1] == 40 && ids[2] == 1 && ids[3] == 1);
    gsf_nn_destroy_tokenizer(&ctx, &t);
    char too_long[1200]; // an added token of 1025 bytes
    snprintf(too_long, sizeof too_long, "{\"added_tokens_decoder\": {\"1\": {\"content\": \"%01025d\"}}}", 0);
    const char* const bad[] = {
        "{\"extra_ids\": -1}", "{\"extra_ids\": 1e9}", "[]", "{", "{\"eos_token\": \"[nowhere]\"}",
        "{\"added_tokens_decoder\": {\"x\": {\"content\": \"y\"}}}",
        "{\"added_tokens_decoder\": {\"1\": {\"content\": 2}}}",
        "{\"added_tokens_decoder\": {\"12345678901\": {\"content\": \"y\"}}}",
        "{\"added_tokens_decoder\": {\"2147483647\": {\"content\": \"y\"}}}",
        "{\"added_tokens_decoder\": {\"1\": {\"content\": \"\"}}}", "{\"added_tokens_decoder\": 5}", too_long};
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        CHECK_RESULT(&ctx, gsf__nn_parse_tokenizer(&ctx, "m", m.data, m.size, bad[i], strlen(bad[i]), &t),
                     GSF_ERROR_FORMAT);
        CHECK(strchr(ctx.error, ':') && t.model == NULL);
    }
    static const char single[] = "{\"added_tokens_decoder\": {\"1\": {\"content\": \"y\", \"single_word\": true}}}";
    CHECK_RESULT(&ctx, gsf__nn_parse_tokenizer(&ctx, "m", m.data, m.size, single, sizeof single - 1, &t),
                 GSF_ERROR_UNSUPPORTED);
    CHECK_RESULT(&ctx, gsf_nn_load_tokenizer(&ctx, test_scratch("nowhere"), &t), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx.error, "spiece.model") != NULL);
}

static void test_tokenizer_memory(void) { // every allocation fails once
    for (size_t k = 1;; k++) {
        gsf_context failing;
        counter memory;
        gsf_nn_tokenizer t;
        int32_t ids[8];
        memset(&memory, 0, sizeof memory);
        memory.fail_at = k;
        test_context_zero(&failing);
        count_memory(&failing, &memory);
        CHECK_OK(&failing, gsf_init_context(&failing));
        gsf_result result = open_made(&failing, 0, &t);
        if (result == GSF_OK) result = gsf_nn_encode_text(&failing, &t, "ab cd <pad>", 11, ids, 8, NULL);
        gsf_nn_destroy_tokenizer(&failing, &t);
        CHECK(memory.live == 0);
        if (result == GSF_OK) break;
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
}

// ---- T5 -----------------------------------------------------------------------------

static const char* t5_folder(void) { return test_golden("restorer/model/text_encoder"); }

static int all_zero(const float* x, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (x[i] != 0.0f) return 0;
    return 1;
}

enum { TEXTS = 2, TOKENS = 37 };

static void make_input(const gsf_nn_t5* net, int32_t* ids, gsf_nn_t5_desc* in) {
    memset(in, 0, sizeof *in);
    for (int i = 0; i < TEXTS * TOKENS; i++) ids[i] = (int32_t)(test_random(&text_seed) * net->vocabulary);
    in->ids = ids;
    in->batch = TEXTS;
    in->tokens = TOKENS;
}

static void test_t5_runs(void) {
    gsf_nn_t5 net;
    gsf_nn_t5_desc in;
    int32_t ids[TEXTS * TOKENS];
    gsf_context three;
    if (!CHECK_OK(&ctx, gsf_nn_load_t5(&ctx, t5_folder(), &net))) return;
    const size_t values = (size_t)TEXTS * TOKENS * (size_t)net.width;
    float *one = (float*)malloc(values * sizeof(float)), *other = (float*)malloc(values * sizeof(float));
    make_input(&net, ids, &in);
    CHECK_OK(&ctx, gsf_nn_encode_t5(&ctx, &net, &in, one));
    test_context_zero(&three);
    work_backwards(&three);
    CHECK_OK(&three, gsf_init_context(&three));
    CHECK_OK(&three, gsf_nn_encode_t5(&three, &net, &in, other));
    CHECK(memcmp(one, other, values * sizeof(float)) == 0);
    float* low = (float*)malloc(values * sizeof(float));
    net.bf16 = 1; // products of bfloat16 where the processor has them
    CHECK_OK(&ctx, gsf_nn_encode_t5(&ctx, &net, &in, other));
    CHECK_OK(&three, gsf_nn_encode_t5(&three, &net, &in, low));
    CHECK(memcmp(low, other, values * sizeof(float)) == 0);
    const double error = test_relative_error(low, one, values);
    if (ctx.cpu_level == GSF_CPU_AVX512_BF16 || ctx.cpu_level == GSF_CPU_AMX) CHECK(error > 1e-5 && error < 2e-2);
    else CHECK(error == 0.0);
    if (getenv("GSF_TEST_VERBOSE")) printf("bf16 t5: relative L2 error %.3g\n", error);
    net.bf16 = 0;
    free(low);
    for (int b = 0; b < TEXTS; b++) { // a batch gives the same as its prompts one by one
        gsf_nn_t5_desc single = in;
        single.batch = 1;
        single.ids = ids + b * TOKENS;
        CHECK_OK(&ctx, gsf_nn_encode_t5(&ctx, &net, &single, other));
        for (size_t i = 0; i < values / TEXTS; i++) CHECK_NEAR(other[i], one[(size_t)b * values / TEXTS + i], 2e-5);
    }
    in.tokens = 1;
    in.batch = 1;
    CHECK_OK(&ctx, gsf_nn_encode_t5(&ctx, &net, &in, other));
    for (int bad = -1; bad <= net.vocabulary; bad += net.vocabulary + 1) {
        ids[0] = bad;
        CHECK_RESULT(&ctx, gsf_nn_encode_t5(&ctx, &net, &in, other), GSF_ERROR_INVALID_ARGUMENT);
    }
    in.tokens = 0;
    CHECK_RESULT(&ctx, gsf_nn_encode_t5(&ctx, &net, &in, other), GSF_ERROR_INVALID_ARGUMENT);
    free(one);
    free(other);
    gsf_nn_destroy_t5(&ctx, &net);
}

static int reports;
static void cancel_at_first(void* user, const char* stage, double done, double total) {
    CHECK(strcmp(stage, "text") == 0 && done >= 1 && done <= total);
    reports++;
    gsf_request_cancel((gsf_context*)user);
}

static size_t largest; // of the requested blocks
static void* measured_alloc(void* user, size_t size) {
    if (size > largest) largest = size;
    return counted_alloc(user, size);
}

static void test_t5_hooks(void) {
    gsf_nn_t5 net;
    gsf_nn_t5_desc in;
    int32_t ids[TEXTS * TOKENS];
    gsf_context other;
    counter memory;
    double bytes = 0.0, flops = 0.0;
    memset(&memory, 0, sizeof memory);
    test_context_zero(&other);
    other.allocator.alloc_fn = measured_alloc;
    other.allocator.free_fn = counted_free;
    other.allocator.user = &memory;
    other.progress.progress_fn = cancel_at_first;
    other.progress.user = &other;
    CHECK_OK(&other, gsf_init_context(&other));
    if (!CHECK_OK(&other, gsf_nn_load_t5(&other, t5_folder(), &net))) return;
    make_input(&net, ids, &in);
    const size_t values = (size_t)TEXTS * TOKENS * (size_t)net.width;
    float* out = (float*)malloc(values * sizeof(float));
    gsf__nn_query_t5(&net, &in, &bytes, &flops);
    const double d = net.width, inner = (double)net.heads * net.head_dim, rows = TEXTS * TOKENS;
    CHECK_NEAR(flops, net.layers * rows * (8 * d * inner + 6 * d * net.hidden + 4 * inner * TOKENS), 1.0);
    largest = 0;
    memset(out, 1, values * sizeof(float));
    CHECK_RESULT(&other, gsf_nn_encode_t5(&other, &net, &in, out), GSF_ERROR_CANCELLED);
    CHECK(reports == 1 && all_zero(out, values));
    CHECK(largest > 0 && bytes > 0.0 && memory.asked > 0);
    gsf_clear_cancel(&other);
    other.progress.progress_fn = NULL;
    CHECK_OK(&other, gsf_nn_encode_t5(&other, &net, &in, out));
    const size_t live = memory.live;
    for (size_t k = 1; k < 100; k++) { // every allocation fails once
        memory.calls = 0;
        memory.fail_at = k;
        const gsf_result result = gsf_nn_encode_t5(&other, &net, &in, out);
        CHECK(memory.live == live);
        if (result == GSF_OK) break;
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
    memory.fail_at = 0;
    in.ids = NULL;
    gsf_nn_destroy_t5(&other, &net);
    CHECK(memory.live == 0);
    for (size_t k = 1; k < 10000; k++) {
        memory.calls = 0;
        memory.fail_at = k;
        const gsf_result result = gsf_nn_load_t5(&other, t5_folder(), &net);
        gsf_nn_destroy_t5(&other, &net);
        CHECK(memory.live == 0);
        if (result == GSF_OK) break;
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
    free(out);
}

// ---- T5: invalid folders

typedef struct changed_model { // the golden model with one tensor changed, in one file
    gsf_nn_weights weights;
    gsf_nn_tensor tensors[512];
    size_t count;
} changed_model;

static gsf_nn_tensor* changed_tensor(changed_model* m, const char* name) {
    for (size_t i = 0; i < m->count; i++)
        if (strcmp(m->tensors[i].name, name) == 0) return &m->tensors[i];
    fprintf(stderr, "no tensor %s\n", name);
    exit(2);
}

static void open_changed(changed_model* m) {
    CHECK_OK(&ctx, gsf_nn_load_weights(&ctx, t5_folder(), "model", &m->weights));
    m->count = m->weights.tensor_count;
    CHECK(m->count < 512);
    memcpy(m->tensors, m->weights.tensors, m->count * sizeof *m->tensors);
}

static void expect_t5(changed_model* m, gsf_result wanted, const char* words) { // on loading or else on encoding
    gsf_nn_t5 net;
    CHECK_OK(&ctx, gsf_nn_save_tensors(&ctx, test_scratch("model.safetensors"), m->tensors, m->count));
    gsf_result result = gsf_nn_load_t5(&ctx, test_scratch("."), &net);
    if (result == GSF_OK) {
        const int32_t ids[3] = {1, 2, 3};
        gsf_nn_t5_desc in;
        memset(&in, 0, sizeof in);
        in.ids = ids;
        in.batch = 1;
        in.tokens = 3;
        float* out = (float*)malloc(3 * (size_t)net.width * sizeof(float));
        result = gsf_nn_encode_t5(&ctx, &net, &in, out);
        CHECK(result == GSF_OK || all_zero(out, 3 * (size_t)net.width));
        free(out);
    }
    gsf_nn_destroy_t5(&ctx, &net);
    CHECK_RESULT(&ctx, result, wanted);
    if (!CHECK(result == GSF_OK || strstr(ctx.error, words))) fprintf(stderr, "    \"%s\": no \"%s\"\n", ctx.error, words);
    gsf_nn_destroy_weights(&ctx, &m->weights);
}

static void test_t5_weights(void) {
    static const char down[] = "encoder.block.1.layer.1.DenseReluDense.wo.weight";
    static const char bias[] = "encoder.block.0.layer.0.SelfAttention.relative_attention_bias.weight";
    changed_model m;
    char path[1200];
    size_t size;
    snprintf(path, sizeof path, "%s/config.json", t5_folder());
    char* config = test_read_file(path, &size);
    write_file("config.json", config, size);
    free(config);
    open_changed(&m);
    expect_t5(&m, GSF_OK, "");
    open_changed(&m);
    gsf_nn_tensor* t = changed_tensor(&m, down);
    float* values = (float*)calloc((size_t)t->count, sizeof(float));
    t->data = values;
    t->dtype = GSF_NN_F32;
    values[t->count / 2] = NAN;
    expect_t5(&m, GSF_ERROR_NUMERIC, down);
    open_changed(&m);
    t = changed_tensor(&m, down);
    t->data = values;
    t->dtype = GSF_NN_F32;
    for (int64_t i = 0; i < t->count; i++) values[i] = 3e38f; // finite, but their products are not
    expect_t5(&m, GSF_ERROR_NUMERIC, "encoder.block.1.");
    free(values);
    open_changed(&m);
    *changed_tensor(&m, bias) = m.tensors[--m.count];
    expect_t5(&m, GSF_ERROR_FORMAT, "is missing");
    open_changed(&m);
    m.tensors[m.count] = m.tensors[0];
    m.tensors[m.count++].name = "decoder.surplus";
    expect_t5(&m, GSF_ERROR_FORMAT, "decoder.surplus");
    open_changed(&m);
    t = changed_tensor(&m, down);
    const int64_t swapped = t->shape[0];
    t->shape[0] = t->shape[1];
    t->shape[1] = swapped;
    expect_t5(&m, GSF_ERROR_FORMAT, "has shape");
}

static void test_t5_configs(void) {
    static const struct { const char* text; gsf_result wanted; } configs[] = {
        {"{}", GSF_ERROR_FORMAT},
        {"{\"d_model\":64,\"d_kv\":16,\"num_heads\":4,\"d_ff\":128,\"num_layers\":2,\"vocab_size\":9,"
         "\"feed_forward_proj\":\"relu\"}", GSF_ERROR_UNSUPPORTED},
        {"{\"d_model\":64,\"d_kv\":16,\"num_heads\":4,\"d_ff\":128,\"num_layers\":2,\"vocab_size\":9,"
         "\"feed_forward_proj\":\"gated-gelu\",\"dense_act_fn\":\"silu\"}", GSF_ERROR_UNSUPPORTED},
        {"{\"d_model\":64,\"d_kv\":16,\"num_heads\":4,\"d_ff\":128,\"num_layers\":2,\"vocab_size\":9,"
         "\"feed_forward_proj\":\"gated-gelu\",\"relative_attention_max_distance\":8}", GSF_ERROR_UNSUPPORTED},
        {"{\"d_model\":64,\"d_kv\":16,\"num_heads\":4,\"d_ff\":128,\"num_layers\":2,\"vocab_size\":9,"
         "\"feed_forward_proj\":\"gated-gelu\"}", GSF_ERROR_FORMAT}, // not the vocabulary size of the embedding table
        {"{\"d_model\":-64}", GSF_ERROR_FORMAT}};
    gsf_nn_t5 net;
    for (size_t i = 0; i < sizeof configs / sizeof configs[0]; i++) {
        write_file("config.json", configs[i].text, strlen(configs[i].text));
        CHECK_RESULT(&ctx, gsf_nn_load_t5(&ctx, test_scratch("."), &net), configs[i].wanted);
        CHECK(net.nets == NULL && net.weights.tensors == NULL);
    }
    CHECK_RESULT(&ctx, gsf_nn_load_t5(&ctx, test_scratch("nowhere"), &net), GSF_ERROR_NOT_FOUND);
}

// ---- as a program for compare_tokenizer.py --------------------------------------------

static int tokenize_stdin(const char* folder) {
    gsf_nn_tokenizer t;
    unsigned char head[4];
    if (gsf_nn_load_tokenizer(&ctx, folder, &t) != GSF_OK) {
        fprintf(stderr, "%s\n", ctx.error);
        return 1;
    }
    while (fread(head, 1, 4, stdin) == 4) {
        const size_t size = head[0] | (size_t)head[1] << 8 | (size_t)head[2] << 16 | (size_t)head[3] << 24;
        char* text = (char*)malloc(size + 1);
        size_t count = 0;
        if (!text || fread(text, 1, size, stdin) != size ||
            gsf_nn_encode_text(&ctx, &t, text, size, NULL, 0, &count) != GSF_OK) return 1;
        int32_t* ids = (int32_t*)malloc(count * sizeof *ids);
        if (!ids || gsf_nn_encode_text(&ctx, &t, text, size, ids, count, NULL) != GSF_OK) return 1;
        for (size_t i = 0; i < count; i++) printf(i ? " %d" : "%d", (int)ids[i]);
        printf("\n");
        free(ids);
        free(text);
    }
    gsf_nn_destroy_tokenizer(&ctx, &t);
    return 0;
}

int main(int argc, char** argv) {
    test_context_init(&ctx);
    if (argc == 3 && strcmp(argv[1], "--tokenize") == 0) return tokenize_stdin(argv[2]);
    const char* folder = test_golden("restorer/model/tokenizer");
    gsf_nn_tokenizer golden, made;
    test_made();
    test_room();
    if (CHECK_OK(&ctx, gsf_nn_load_tokenizer(&ctx, folder, &golden))) test_odd_t5_texts(&golden);
    if (CHECK_OK(&ctx, open_made(&ctx, MADE_BYTES | MADE_NO_TRIM, &made))) test_odd_t5_texts(&made);
    gsf_nn_destroy_tokenizer(&ctx, &golden);
    gsf_nn_destroy_tokenizer(&ctx, &made);
    test_long_texts(folder);
    test_bad_made();
    test_bad_golden(folder);
    test_refusals();
    test_tokenizer_configs();
    test_tokenizer_memory();
    test_t5_runs();
    test_t5_hooks();
    test_t5_weights();
    test_t5_configs();
    return test_report();
}
