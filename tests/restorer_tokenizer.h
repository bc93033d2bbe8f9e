// restorer_tokenizer.h - token ids must equal those of transformers' tokenizer.
#ifndef RESTORER_TOKENIZER_H
#define RESTORER_TOKENIZER_H

#include "restorer_golden.h"

// ids: an array in the file. All further ids in `actual` must be padding.
static void check_ids(const gsf_json* file, const gsf_json_value* ids, const gsf_nn_tokenizer* t, const int32_t* actual,
                      size_t room, const char* text) {
    int same = ids && ids->type == GSF_JSON_ARRAY && ids->count <= room;
    size_t n = 0;
    for (uint32_t i = same ? ids->child : 0; i; i = file->values[i].next)
        same &= actual[n++] == (int32_t)file->values[i].number;
    for (; n < room; n++) same &= actual[n] == t->pad_id;
    if (!CHECK(same)) fprintf(stderr, "    ids of \"%s\" (room %zu)\n", text, room);
}

static void check_tokenizer_case(gsf_context* ctx, const gsf_json* file, const gsf_json_value* c,
                                 const gsf_nn_tokenizer* t) {
    const gsf_json_value* text = gsf_find_json_member(file, c, "text");
    const gsf_json_value* padded = gsf_find_json_member(file, c, "ids_padded");
    const gsf_json_value* all = gsf_find_json_member(file, c, "ids_untruncated");
    size_t count = 0, same = 0;
    if (!CHECK(text && text->type == GSF_JSON_STRING && padded && padded->type == GSF_JSON_OBJECT && all)) return;
    CHECK_OK(ctx, gsf_nn_encode_text(ctx, t, text->string, text->string_size, NULL, 0, &count));
    CHECK(count == all->count);
    int32_t* ids = (int32_t*)malloc((count + 1000) * sizeof *ids);
    CHECK_OK(ctx, gsf_nn_encode_text(ctx, t, text->string, text->string_size, ids, count, &same));
    CHECK(same == count);
    check_ids(file, all, t, ids, count, text->string);
    for (uint32_t i = padded->child; i; i = file->values[i].next) { // "26": [...]
        const size_t room = (size_t)atoi(file->values[i].key);
        if (!CHECK(room > 0 && room < 1000 && file->values[i].count == room)) continue;
        CHECK_OK(ctx, gsf_nn_encode_text(ctx, t, text->string, text->string_size, ids, room, NULL));
        check_ids(file, &file->values[i], t, ids, room, text->string);
    }
    for (uint32_t i = c->child; i; i = file->values[i].next) { // "ids_226_without_trailing_pad"
        const size_t room = strncmp(file->values[i].key, "ids_", 4) == 0 ? (size_t)atoi(file->values[i].key + 4) : 0;
        if (room == 0 || room >= 1000) continue;
        CHECK_OK(ctx, gsf_nn_encode_text(ctx, t, text->string, text->string_size, ids, room, NULL));
        check_ids(file, &file->values[i], t, ids, room, text->string);
    }
    free(ids);
}

static void check_tokenizer(void) {
    gsf_context ctx;
    gsf_nn_tokenizer t;
    gsf_json file;
    size_t size, cases = 0;
    test_context_init(&ctx);
    char* text = test_read_file(test_golden("restorer/tokenizer/cases.json"), &size);
    if (!CHECK_OK(&ctx, gsf_parse_json(&ctx, "cases.json", text, size, &file))) return;
    if (!CHECK_OK(&ctx, gsf_nn_load_tokenizer(&ctx, test_golden("restorer/model/tokenizer"), &t))) return;
    const gsf_json_value* root = &file.values[0];
    CHECK(t.pad_id == (int32_t)gsf_find_json_member(&file, root, "pad_id")->number);
    CHECK(t.end_id == (int32_t)gsf_find_json_member(&file, root, "eos_id")->number);
    CHECK(t.unknown_id == (int32_t)gsf_find_json_member(&file, root, "unk_id")->number);
    CHECK(t.piece_count == (int32_t)gsf_find_json_member(&file, root, "sp_vocab_size")->number);
    CHECK(t.id_count == (int32_t)gsf_find_json_member(&file, root, "total_vocab")->number);
    for (uint32_t i = gsf_find_json_member(&file, root, "cases")->child; i; i = file.values[i].next, cases++)
        check_tokenizer_case(&ctx, &file, &file.values[i], &t);
    CHECK(cases > 0);
    gsf_nn_destroy_tokenizer(&ctx, &t);
    gsf_destroy_json(&ctx, &file);
    free(text);
}

#endif
