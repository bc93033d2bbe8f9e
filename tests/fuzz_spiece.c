// fuzz_spiece.c - the SentencePiece tokenizer. Build line: fuzz.h, without -DGSFIXER_IMPLEMENTATION. The first byte selects
// the rest: 255 a spiece.model; otherwise a text for the model of made_spiece.h with the flags of the low six bits.
#define GSFIXER_IMPLEMENTATION
#include "fuzz.h"

#include "gsfixer_nn.h"
#include "made_spiece.h"

// Ids are in range, with a single </s>, and do not depend on the capacity of the output.
static void check_text(gsf_context* ctx, const gsf_nn_tokenizer* t, const char* text, size_t size) {
    size_t count = 0, again = 0;
    FUZZ_CHECK(gsf_nn_encode_text(ctx, t, text, size, NULL, 0, &count) == GSF_OK && count > 0);
    int32_t* ids = (int32_t*)malloc((count + 1) * sizeof *ids);
    FUZZ_CHECK(ids && gsf_nn_encode_text(ctx, t, text, size, ids, count + 1, &again) == GSF_OK && again == count);
    for (size_t i = 0; i < count; i++) FUZZ_CHECK(ids[i] >= 0 && ids[i] < t->id_count);
    FUZZ_CHECK(ids[count - 1] == t->end_id && ids[count] == t->pad_id);
    int32_t few[4];
    FUZZ_CHECK(gsf_nn_encode_text(ctx, t, text, size, few, 4, NULL) == GSF_OK);
    for (size_t i = 0; i < 3 && i < count; i++) FUZZ_CHECK(few[i] == ids[i]);
    free(ids);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    static const char fixed[] = " ab A\tu[K]\xe4\xb8\xad <pad> xyz\xff\xc3\xa9 The</s>";
    gsf_context ctx = fuzz_context(size);
    gsf_nn_tokenizer t;
    if (size == 0) return 0;
    const char* rest = (const char*)data + 1;
    if (data[0] == 255) {
        if (gsf__nn_parse_tokenizer(&ctx, "fuzz", rest, size - 1, NULL, 0, &t) == GSF_OK) {
            check_text(&ctx, &t, fixed, sizeof fixed - 1);
            check_text(&ctx, &t, rest, size - 1 < 64 ? size - 1 : 64);
        } else {
            FUZZ_CHECK(strncmp(ctx.error, "fuzz:", 5) == 0 && t.model == NULL);
        }
    } else {
        made_bytes m;
        made_spiece(data[0] & 63, &m);
        FUZZ_CHECK(gsf__nn_parse_tokenizer(&ctx, "made", m.data, m.size, NULL, 0, &t) == GSF_OK);
        check_text(&ctx, &t, rest, size - 1 < 1024 ? size - 1 : 1024);
    }
    gsf_nn_destroy_tokenizer(&ctx, &t);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
