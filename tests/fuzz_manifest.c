// fuzz_manifest.c - manifests: of a sequence and of a scene (gsfix dataset), which others may have written, and the list of
// files in an output folder's .gsfix/manifest. Build line: fuzz.h, with the other examples/gsfix*.c. Accepted manifests name
// files inside their folder only; refused ones give a one-line error; a list of files survives being written and read again.
#include "../examples/gsfix_out.c"

#include "fuzz.h"

static void check_text(const char* text) {
    FUZZ_CHECK(text);
    for (; *text; text++) FUZZ_CHECK((unsigned char)*text >= 0x20 && *text != 0x7f);
}

static void check_path(const char* path) { // stays in the folder that it is relative to
    check_text(path);
    FUZZ_CHECK(*path && *path != '/' && !strstr(path, "//") && path[strlen(path) - 1] != '/');
    for (const char* p = path; p; p = strchr(p, '/') ? strchr(p, '/') + 1 : NULL)
        FUZZ_CHECK(strcmp(p, "..") && strncmp(p, "../", 3) && strcmp(p, ".") && strncmp(p, "./", 2));
}

static gsf_result read_sequence(gsf_context* ctx, const char* text, size_t size) {
    gsfix_sequence s;
    const gsf_result result = gsfix_parse_sequence(ctx, "fuzz", text, size, &s);
    if (result != GSF_OK) {
        FUZZ_CHECK(!s.frames && !s.json.values);
        return result;
    }
    FUZZ_CHECK(s.frame_count >= 2 && s.width > 0 && s.height > 0 && s.views >= 2 && s.index >= 0);
    FUZZ_CHECK(s.frames[0].reference && s.frames[s.frame_count - 1].reference);
    check_text(s.scene);
    check_text(s.kind);
    check_text(s.caption);
    check_path(s.cameras);
    for (size_t i = 0; i < s.frame_count; i++) {
        check_path(s.frames[i].name);
        check_text(s.frames[i].photo);
        for (int f = 0; f < GSFIX_FRAME_FILES; f++) check_path(s.frames[i].files[f]);
    }
    gsfix_free_sequence(ctx, &s);
    return GSF_OK;
}

static gsf_result read_scene(gsf_context* ctx, const char* text, size_t size) {
    gsfix_scene_manifest m;
    const gsf_result result = gsfix_parse_scene_manifest(ctx, "fuzz", text, size, &m);
    if (result != GSF_OK) {
        FUZZ_CHECK(!m.sequences && !m.json.values);
        return result;
    }
    FUZZ_CHECK(m.sequence_count >= 1 && m.settings);
    check_text(m.name);
    for (size_t i = 0; i < m.sequence_count; i++) {
        check_path(m.sequences[i].file);
        FUZZ_CHECK(m.sequences[i].frames >= 2);
    }
    gsfix_free_scene_manifest(ctx, &m);
    return GSF_OK;
}

static void read_files(gsf_context* ctx, const char* text, size_t size) {
    gsfix_out files, again;
    gsf_buffer written = {0};
    size_t longest = 0;
    memset(&files, 0, sizeof files);
    memset(&again, 0, sizeof again);
    FUZZ_CHECK(parse_manifest(ctx, &files, text, size) == GSF_OK);
    for (size_t i = 0; i < files.line_count; i++) {
        const size_t n = strlen(files.lines[i].name);
        if (n > longest) longest = n;
        print_line(ctx, &written, files.lines + i);
    }
    FUZZ_CHECK(!written.failed && parse_manifest(ctx, &again, written.data ? written.data : "", written.size) == GSF_OK);
    for (size_t i = 0; i < files.line_count && longest < 1000; i++) { // longer ones may be cut when each byte is escaped
        const out_line *a = files.lines + i, *b = again.lines + i;
        FUZZ_CHECK(i < again.line_count && a->size == b->size && a->digest == b->digest);
        FUZZ_CHECK(strcmp(a->name, b->name) == 0 && strcmp(a->command, b->command) == 0);
    }
    while (files.line_count) drop_line(ctx, &files, files.line_count - 1);
    while (again.line_count) drop_line(ctx, &again, again.line_count - 1);
    gsf_free(ctx, files.lines);
    gsf_free(ctx, again.lines);
    gsf_destroy_buffer(ctx, &written);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    const char* text = size ? (const char*)data : "";
    gsf_context ctx = fuzz_context(size);
    if (size && data[0] != '{') {
        fuzz_limit += 8192 + 128 * size; // names may be as long as a path; their list doubles
        read_files(&ctx, text, size);
    } else {
        const gsf_result sequence = read_sequence(&ctx, text, size), scene = read_scene(&ctx, text, size);
        FUZZ_CHECK(sequence == GSF_OK || sequence == GSF_ERROR_FORMAT);
        FUZZ_CHECK(scene == GSF_OK || scene == GSF_ERROR_FORMAT);
        if (sequence != GSF_OK || scene != GSF_OK) fuzz_check_error(&ctx, "fuzz:");
    }
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
