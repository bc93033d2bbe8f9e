// Files by name: UTF-8 names and long paths; a file is replaced at once or not at all, also by a program that is killed, and
// while somebody else has the old file open. The program starts itself as the writer.
#define _POSIX_C_SOURCE 200809L
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"

#ifndef _WIN32
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>
#endif

enum { BIGGEST = 1 << 17 };

// ---- the writer: replaces a file by others of different sizes, without end ----------

// A file of `size` bytes that all follow from the first one.
static void fill(unsigned char* bytes, size_t size, unsigned turn) {
    for (size_t i = 0; i < size; i++) bytes[i] = (unsigned char)(turn + i * 7);
}

static size_t size_of(unsigned turn) { return 1000 + 17 * (turn % 256) * (turn % 256) % (BIGGEST - 1000); }

static int write_forever(const char* path) {
    static unsigned char bytes[BIGGEST];
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_init_context(&ctx) != GSF_OK) return 1;
    for (unsigned turn = 0;; turn++) {
        fill(bytes, size_of(turn), turn);
        if (gsf_write_file(&ctx, path, bytes, size_of(turn)) != GSF_OK) return fprintf(stderr, "%s\n", ctx.error), 1;
    }
}

// ---- processes -------------------------------------------------------------------------

#ifdef _WIN32
typedef HANDLE process;
static process start(const char* program, const char* path) {
    char line[2048];
    STARTUPINFOA info;
    PROCESS_INFORMATION made;
    memset(&info, 0, sizeof info);
    info.cb = sizeof info;
    snprintf(line, sizeof line, "\"%s\" --write \"%s\"", program, path);
    if (!CreateProcessA(NULL, line, NULL, NULL, TRUE, 0, NULL, NULL, &info, &made)) return NULL;
    CloseHandle(made.hThread);
    return made.hProcess;
}
static void wait_ms(unsigned ms) { Sleep(ms); }
static int is_running(process p) { return WaitForSingleObject(p, 0) == WAIT_TIMEOUT; }
static void end(process p) {
    TerminateProcess(p, 1);
    WaitForSingleObject(p, 10000);
    CloseHandle(p);
}
#else
typedef pid_t process;
static process start(const char* program, const char* path) {
    const pid_t child = fork();
    if (child == 0) {
        execl(program, program, "--write", path, (char*)NULL);
        _exit(127);
    }
    return child;
}
static void wait_ms(unsigned ms) {
    const struct timespec pause = {0, 1000000L * (long)ms};
    nanosleep(&pause, NULL);
}
static int is_running(process p) { return waitpid(p, NULL, WNOHANG) == 0; }
static void end(process p) {
    kill(p, SIGKILL);
    waitpid(p, NULL, 0);
}
#endif

// ---- tests -----------------------------------------------------------------------------

static int is_whole(gsf_context* ctx, const char* path) {
    static unsigned char expected[BIGGEST];
    unsigned char* data;
    size_t size;
    if (gsf_read_file(ctx, path, (void**)&data, &size) != GSF_OK) return 0;
    int whole = size > 0 && size_of(data[0]) == size;
    if (whole) {
        fill(expected, size, data[0]);
        whole = memcmp(expected, data, size) == 0;
    }
    gsf_free(ctx, data);
    return whole;
}

static void test_killed_writer(gsf_context* ctx, const char* program) {
    const char* path = test_scratch("replaced.bin");
    uint64_t random = 3;
    const int kills = test_few(40, 10);
    static const unsigned char old[] = {0};
    remove(path);
    CHECK(gsf_write_file(ctx, path, old, 0) == GSF_OK);
    const process first = start(program, path);
    for (int i = 0; i < 500 && !is_whole(ctx, path); i++) wait_ms(10); // it has begun
    end(first);
    CHECK(is_whole(ctx, path));
    for (int i = 0; i < kills; i++) {
        const process writer = start(program, path);
        wait_ms(5 + (unsigned)(test_random(&random) * 60.0));
        int reads = 0; // a reader keeps the file open, and always finds a whole one
        for (; reads < 20; reads++)
            if (!is_whole(ctx, path)) break;
        CHECK(reads == 20);
        CHECK(is_running(writer));
        end(writer);
        if (!CHECK(is_whole(ctx, path))) break;
        for (int k = 0; k < 100; k++) { // what the killed writer left behind
            char left[1200];
            snprintf(left, sizeof left, k ? "%s.tmp%d" : "%s.tmp", path, k);
            remove(left);
        }
    }
    remove(path);
}

// Held by a reader for a while: the writer waits for it, or replaces the file under it.
static void test_open_file(gsf_context* ctx) {
    const char* path = test_scratch("held.bin");
    CHECK(gsf_write_file(ctx, path, "old", 3) == GSF_OK);
    FILE* reader = gsf__open_path(ctx, path, GSF__OPEN_READ);
    CHECK(reader != NULL);
    const gsf_result result = gsf_write_file(ctx, path, "newer", 5);
    char text[8] = "";
    CHECK(reader && fread(text, 1, 3, reader) == 3 && memcmp(text, "old", 3) == 0);
    if (reader) fclose(reader);
    void* data;
    size_t size;
    CHECK(gsf_read_file(ctx, path, &data, &size) == GSF_OK);
    CHECK(result == GSF_OK ? size == 5 : size == 3); // one of both, whole
    gsf_free(ctx, data);
    CHECK(gsf_write_file(ctx, path, "newest", 6) == GSF_OK);
    remove(path);
}

// ---- names

static int make_folder(gsf_context* ctx, const char* path) {
#ifdef _WIN32
    gsf__wide wide;
    gsf__widen_path(ctx, path, &wide);
    const int ok = wide.text && (CreateDirectoryW(wide.text, NULL) || GetLastError() == ERROR_ALREADY_EXISTS);
    gsf__free_wide(ctx, &wide);
    return ok;
#else
    (void)ctx;
    return mkdir(path, 0777) == 0 || errno == EEXIST;
#endif
}

// Whether the folder holds a file of exactly this name.
static int lists(gsf_context* ctx, const char* folder, const char* name) {
    gsf__nn_listing listing;
    memset(&listing, 0, sizeof listing);
    listing.folder = folder;
    listing.suffix = ".safetensors";
    const int ok = gsf__nn_list_folder(ctx, &listing) == GSF_OK;
    const int found = ok && listing.found.size && strcmp(listing.found.data, name) == 0;
    gsf_destroy_buffer(ctx, &listing.found);
    return found;
}

static void check_names_in(gsf_context* ctx, const char* folder) {
    static const char* const names[] = {"wide_\xc3\xbc_\xe6\x97\xa5.safetensors",        // u umlaut, CJK
                                        "\xf0\x9f\x98\x80 \xc3\x84\xc3\x96.safetensors"}; // beyond 16 bits, a blank
    for (size_t i = 0; i < GSF__COUNT(names); i++) {
        char path[2048];
        void* data;
        size_t size;
        const unsigned char* mapped;
        snprintf(path, sizeof path, "%s/%s", folder, names[i]);
        for (int turn = 0; turn < 2; turn++) { // made, then replaced
            CHECK_OK(ctx, gsf_write_file(ctx, path, "0123456789", 10 - (size_t)turn));
            if (CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size))) {
                CHECK(size == 10 - (size_t)turn && memcmp(data, "0123456789", size) == 0);
                gsf_free(ctx, data);
            }
        }
        CHECK(gsf__look_at_path(ctx, path) == GSF__PATH_FILE);
        CHECK_OK(ctx, gsf__nn_map(ctx, path, &mapped, &size));
        CHECK(mapped && size == 9 && memcmp(mapped, "012345678", 9) == 0);
        if (mapped) gsf__nn_unmap(mapped, size);
        CHECK(lists(ctx, folder, names[i]));
        gsf__remove_path(ctx, path);
        CHECK(gsf__look_at_path(ctx, path) == GSF__PATH_UNKNOWN);
        CHECK(gsf_read_file(ctx, path, &data, &size) == GSF_ERROR_NOT_FOUND);
    }
}

static void check_names(gsf_context* ctx) {
    char folder[2048];
    snprintf(folder, sizeof folder, "%s", test_scratch("names_\xc3\xa4"));
    CHECK(make_folder(ctx, folder));
    check_names_in(ctx, folder);
    for (int depth = 0; depth < 7; depth++) { // 7 x 60 characters: longer than 260
        const size_t size = strlen(folder);
        snprintf(folder + size, sizeof folder - size, "/%d_\xe6\x97\xa5_%054d", depth, 0);
        CHECK(make_folder(ctx, folder));
    }
    CHECK(gsf__look_at_path(ctx, folder) == GSF__PATH_FOLDER);
    check_names_in(ctx, folder);
}

static void test_refusals(gsf_context* ctx) {
    void* data;
    size_t size;
    CHECK(gsf_read_file(ctx, test_scratch("none/at all"), &data, &size) == GSF_ERROR_NOT_FOUND);
    CHECK(gsf_write_file(ctx, test_scratch("none/at all"), "x", 1) == GSF_ERROR_IO);
    CHECK(gsf_read_file(ctx, test_scratch(""), &data, &size) == GSF_ERROR_IO && strstr(ctx->error, "is a folder"));
#ifdef _WIN32
    CHECK(gsf_write_file(ctx, test_scratch("not utf-8 \xff"), "x", 1) == GSF_ERROR_IO);
    CHECK(gsf_write_file(ctx, "NUL", "x", 1) == GSF_OK); // a device
#endif
}

int main(int argc, char** argv) {
    if (argc == 3 && strcmp(argv[1], "--write") == 0) return write_forever(argv[2]);
    gsf_context ctx;
    test_context_init(&ctx);
    check_names(&ctx);
    test_refusals(&ctx);
    test_open_file(&ctx);
    test_killed_writer(&ctx, argv[0]);
    return test_report();
}
