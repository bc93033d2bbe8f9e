// test_checkpoint.c - gsfix fix --resume with forged numbers in the checkpoint: refused with one line, or harmless
#include "../examples/gsfix.h"

#ifdef GSF_USE_EMBREE
#include "made_scene.h"
#endif
#include "test.h"

#include <unistd.h>

#ifdef GSF_USE_EMBREE

int gsfix_main(int argc, char** argv);

static const char* const scene_folder = TEST_TMP "/scene";
static const char* const out = TEST_TMP "/out";

static int resume(const char* option) { // exit status of the program; its lines go to TEST_TMP/stderr
    const char* arguments[] = {"gsfix", "fix", scene_folder, "--out", out, "--views", "2", "--iterations", "4",
                               "--threads", "1",
                               "--restorer", "warp", "--set", "rounds=1,windows=1,window_frames=3,first_round=2,last_round=2",
                               "--compare", "--json", option};
    char* copies[sizeof arguments / sizeof *arguments + 1] = {NULL};
    const int count = (int)(sizeof arguments / sizeof *arguments);
    for (int i = 0; i < count; i++) copies[i] = (char*)(uintptr_t)arguments[i];
    fflush(NULL);
    const int keep[2] = {dup(1), dup(2)};
    if (!freopen(TEST_TMP "/stdout", "w", stdout) || !freopen(TEST_TMP "/stderr", "w", stderr)) return -1;
    const int status = gsfix_main(count, copies);
    fflush(NULL);
    dup2(keep[0], 1);
    dup2(keep[1], 2);
    close(keep[0]);
    close(keep[1]);
    return status;
}

static int error_lines(gsf_context* ctx) {
    void* data;
    size_t size;
    int lines = 0;
    if (!CHECK_OK(ctx, gsf_read_file(ctx, TEST_TMP "/stderr", &data, &size))) return -1;
    for (const char* p = (const char*)data; (p = strstr(p, "gsfix fix: ")) != NULL; p++) lines++;
    gsf_free(ctx, data);
    return lines;
}

// Writes the checkpoint to the output folder as the program would have.
static void put_checkpoint(const void* data, size_t size) {
    gsfix_app app;
    memset(&app, 0, sizeof app);
    app.command = "fix";
    app.o.out = out;
    test_context_init(&app.ctx);
    CHECK_OK(&app.ctx, gsfix_begin_files(&app));
    CHECK_OK(&app.ctx, gsfix_claim(&app, "checkpoint"));
    CHECK_OK(&app.ctx, gsfix_open_out(&app));
    CHECK_OK(&app.ctx, gsf_write_file(&app.ctx, TEST_TMP "/out/checkpoint", data, size));
    gsfix_end_files(&app);
}

// Writes the checkpoint `data` with its JSON replaced.
static void forge(gsf_context* ctx, const void* data, size_t size, const char* json, size_t json_size) {
    gsf_buffer file = {0};
    const char* p = (const char*)data + 12; // after magic and version
    while ((size_t)(p - (const char*)data) + 16 <= size) {
        uint64_t bytes = 0;
        char tag[5] = "";
        memcpy(tag, p, 4);
        for (int i = 0; i < 8; i++) bytes |= (uint64_t)(unsigned char)p[4 + i] << 8 * i;
        if (strcmp(tag, "END ") == 0) break;
        if (strcmp(tag, "GFIX") == 0) gsf_append_chunk(ctx, &file, tag, json, json_size);
        else gsf_append_chunk(ctx, &file, tag, p + 12, (size_t)bytes);
        p += 16 + bytes;
    }
    gsf_append_last_chunk(ctx, &file);
    if (CHECK(!file.failed)) put_checkpoint(file.data, file.size);
    gsf_destroy_buffer(ctx, &file);
}

static size_t number_at(const char* text) { // length of the number or of "null" at text; 0 if neither
    const size_t n = strspn(text, "+-.0123456789eE");
    return n ? n : strncmp(text, "null", 4) == 0 ? 4 : 0;
}

// Replaces each number of the first row of a list (or the single number) by each of the values in turn.
static void forge_list(gsf_context* ctx, const void* data, size_t size, const char* json, size_t json_size, const char* key,
                       const char* wholes) {
    static const char* const values[] = {"-1e300", "1e300", "1.5", "-7", "4294967296", "[]", "null", "\"x\""};
    const char* at = strstr(json, key);
    if (!CHECK(at != NULL)) return;
    at += strlen(key);
    at += strspn(at, ":[");
    for (size_t column = 0; number_at(at); column++) {
        for (size_t v = 0; v < sizeof values / sizeof *values; v++) {
            if (wholes[column] != 'w' && v % 2 == 0) continue; // every other value is enough for non-integers
            gsf_buffer text = {0};
            gsf_append_bytes(ctx, &text, json, (size_t)(at - json));
            gsf_append_bytes(ctx, &text, values[v], strlen(values[v]));
            gsf_append_bytes(ctx, &text, at + number_at(at), json_size - (size_t)(at - json) - number_at(at));
            forge(ctx, data, size, text.data, text.size);
            const int status = resume("--resume"), must_fail = wholes[column] == 'w' && v != 4;
            if (!CHECK(status == 1 || (status == 0 && !must_fail)) || !CHECK(error_lines(ctx) == (status == 1)))
                printf("  %s, column %zu: %s\n", key, column, values[v]);
            gsf_destroy_buffer(ctx, &text);
        }
        at += number_at(at);
        if (*at != ',') break;
        at++;
    }
}

static void test_forged(gsf_context* ctx) {
    void* data = NULL;
    size_t size;
    gsf_chunk chunk;
    if (!CHECK(resume("--restart") == 0) || !CHECK(resume("--resume") == 0)) return;
    if (!CHECK_OK(ctx, gsf_read_file(ctx, TEST_TMP "/out/checkpoint", &data, &size))) return;
    if (CHECK(gsf_find_chunk(data, size, "GFIX", &chunk))) {
        gsf_buffer json = {0};
        gsf_append_bytes(ctx, &json, (const char*)chunk.data, chunk.size);
        forge(ctx, data, size, json.data, json.size); // restore the original
        CHECK(resume("--resume") == 0);
        forge_list(ctx, data, size, json.data, json.size, "\"iteration\"", "w");
        forge_list(ctx, data, size, json.data, json.size, "\"resumed\"", "w");
        forge_list(ctx, data, size, json.data, json.size, "\"seconds_total\"", "f");
        forge_list(ctx, data, size, json.data, json.size, "\"seconds\"", "ffffffff");
        forge_list(ctx, data, size, json.data, json.size, "\"comparing\"", "w");
        forge_list(ctx, data, size, json.data, json.size, "\"without\"", "nnnn");
        forge_list(ctx, data, size, json.data, json.size, "\"without_curve\"", "wcnn");
        forge_list(ctx, data, size, json.data, json.size, "\"curve\"", "wcnn");
        forge_list(ctx, data, size, json.data, json.size, "\"rounds\":[[", "wwwwwf");
        forge_list(ctx, data, size, json.data, json.size, "\"path\"", "wwwffffff");
        forge_list(ctx, data, size, json.data, json.size, "\"samples\"", "www");
        gsf_destroy_buffer(ctx, &json);
    }
    gsf_free(ctx, data);
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    make_scene_options options = make_scene_defaults;
    options.views = 4;
    options.points = 300;
    options.width = 32;
    options.height = 24;
    if (CHECK(make_scene(&ctx, &options, scene_folder) == 0)) test_forged(&ctx);
    remove_scene(scene_folder, options.views);
    return test_report();
}

#else
int main(void) { return 77; } // the test scene needs Embree
#endif
