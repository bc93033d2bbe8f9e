// made_spiece.h - a small spiece.model with pieces of every kind, for the test and the fuzz target of the tokenizer.
#ifndef MADE_SPIECE_H
#define MADE_SPIECE_H

#include <stdint.h>
#include <string.h>

enum { // parts that made_spiece leaves out or adds
    MADE_NO_PREFIX = 1, MADE_NO_TRIM = 2, MADE_NO_ESCAPE = 4, MADE_SUFFIX = 8, MADE_BYTES = 16, MADE_NO_MAP = 32
};

enum { MADE_UNITS = 256, MADE_ROOM = 8192 };

typedef struct made_bytes {
    unsigned char data[MADE_ROOM];
    size_t size;
} made_bytes;

static inline void made_number(made_bytes* out, uint64_t value) {
    for (; value > 127; value >>= 7) out->data[out->size++] = (unsigned char)(value | 128);
    out->data[out->size++] = (unsigned char)value;
}

static inline void made_varint(made_bytes* out, int field, uint64_t value) {
    made_number(out, (uint64_t)field << 3);
    made_number(out, value);
}

static inline void made_field(made_bytes* out, int field, const void* data, size_t size) {
    made_number(out, (uint64_t)field << 3 | 2);
    made_number(out, size);
    memcpy(out->data + out->size, data, size);
    out->size += size;
}

static inline void made_piece(made_bytes* out, const char* text, float score, int type) {
    made_bytes piece;
    uint32_t bits;
    piece.size = 0;
    made_field(&piece, 1, text, strlen(text));
    memcpy(&bits, &score, sizeof bits);
    made_number(&piece, 2 << 3 | 5);
    for (int i = 0; i < 4; i++) piece.data[piece.size++] = (unsigned char)(bits >> 8 * i);
    if (type != 1) made_varint(&piece, 3, (uint64_t)type);
    made_field(out, 1, piece.data, piece.size);
}

// Character map: 'A' becomes "b c", 'Q' nothing, tab a space.
static inline void made_map(made_bytes* normalizer) {
    unsigned char map[4 + 4 * MADE_UNITS + 7] = {0};
    uint32_t units[MADE_UNITS] = {0};
    static const struct { unsigned char byte, value; } entries[] = {{'A', 0}, {'Q', 4}, {'\t', 5}};
    units[0] = 128u << 10; // children are at 128 ^ byte, their values at 1, 2, 3
    for (uint32_t i = 0; i < 3; i++) {
        const uint32_t at = 128u ^ entries[i].byte;
        units[at] = entries[i].byte | 256u | (at ^ (i + 1)) << 10;
        units[i + 1] = 0x80000000u | entries[i].value;
    }
    units[128] = 0x80000000u; // no child for a zero byte
    map[1] = 4;                // 1024 bytes of trie
    for (size_t i = 0; i < MADE_UNITS; i++)
        for (int k = 0; k < 4; k++) map[4 + 4 * i + (size_t)k] = (unsigned char)(units[i] >> 8 * k);
    memcpy(map + 4 + 4 * MADE_UNITS, "b c\0\0 ", 7);
    made_field(normalizer, 2, map, sizeof map);
}

// Ids: 0 <pad>, 1 </s>, 2 <unk>, 3 ... as listed; with MADE_BYTES, 256 byte pieces follow.
static inline void made_spiece(int flags, made_bytes* out) {
    made_bytes part;
    out->size = 0;
    made_piece(out, "<pad>", 0, 3);
    made_piece(out, "</s>", 0, 3);
    made_piece(out, "<unk>", 0, 2);
    made_piece(out, "\xe2\x96\x81", -3, 1);
    made_piece(out, "a", -2, 1);
    made_piece(out, "b", -2.5f, 1);          // 5
    made_piece(out, "c", -4, 1);
    made_piece(out, "ab", -3, 1);
    made_piece(out, "\xe2\x96\x81" "ab", -5, 1);
    made_piece(out, "bc", -7, 1);
    made_piece(out, "[K]", 0, 4);            // 10: user-defined
    made_piece(out, "u", -1, 5);             // unused
    made_piece(out, "\xe4\xb8\xad", -3.5f, 1);
    made_piece(out, " ", -3, 1);             // where spaces are not escaped
    for (int i = 0; flags & MADE_BYTES && i < 256; i++) {
        static const char digits[] = "0123456789ABCDEF";
        const char text[7] = {'<', '0', 'x', digits[i >> 4], digits[i & 15], '>', 0};
        made_piece(out, text, 0, 6);
    }
    part.size = 0;
    made_varint(&part, 3, 1);
    if (flags & MADE_SUFFIX) made_varint(&part, 24, 1);
    if (flags & MADE_BYTES) made_varint(&part, 35, 1);
    made_field(out, 2, part.data, part.size);
    part.size = 0;
    made_field(&part, 1, "made", 4);
    if (!(flags & MADE_NO_MAP)) made_map(&part);
    if (flags & MADE_NO_PREFIX) made_varint(&part, 3, 0);
    if (flags & MADE_NO_TRIM) made_varint(&part, 4, 0);
    if (flags & MADE_NO_ESCAPE) made_varint(&part, 5, 0);
    made_field(out, 3, part.data, part.size);
}

#endif
