// Context, memory, random numbers, text, files and chunks of gsfixer.h.
#ifdef __linux__
#define _XOPEN_SOURCE 700
#include <signal.h>
#include <sys/resource.h>
#include <unistd.h>
#endif
#include "gsfixer.h"
#include "test.h"

static void test_bad_hooks(void) {
    gsf_context ctx;
    test_context_zero(&ctx);
    ctx.threads = -1;
    CHECK_RESULT(&ctx, gsf_init_context(&ctx), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx.error, "threads") != NULL);
    test_context_zero(&ctx);
    ctx.parallel.worker_count = 2; // of what?
    CHECK_RESULT(&ctx, gsf_init_context(&ctx), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx.error, "for_fn") != NULL);
    test_context_zero(&ctx);
    ctx.allocator.user = &ctx;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    CHECK_RESULT(&ctx, gsf_init_context(NULL), GSF_ERROR_INVALID_ARGUMENT);
}

static void test_memory(gsf_context* ctx) {
    for (size_t size = 0; size < 300; size += 7) {
        char* p = (char*)gsf_alloc_zeroed(ctx, size, 1);
        if (!CHECK(p != NULL)) return;
        CHECK((uintptr_t)p % 64 == 0);
        for (size_t i = 0; i < size; i++) CHECK(p[i] == 0);
        gsf_free(ctx, p);
    }
    CHECK(gsf_alloc(ctx, SIZE_MAX / 2, 3) == NULL);
    CHECK(strstr(ctx->error, "out of memory") != NULL);
    gsf_free(ctx, NULL);
}

static void test_random_numbers(void) {
    double mean = 0.0, variance = 0.0, uniform = 0.0;
    enum { COUNT = 20000 };
    for (uint64_t i = 0; i < COUNT; i++) {
        const double x = gsf_draw_normal(5, 2, i), u = gsf_draw_uniform(5, 3, i);
        mean += x;
        variance += x * x;
        uniform += u;
        CHECK(u >= 0.0 && u < 1.0);
    }
    CHECK_NEAR(mean / COUNT, 0.0, 0.03); // four standard errors
    CHECK_NEAR(variance / COUNT, 1.0, 0.04);
    CHECK_NEAR(uniform / COUNT, 0.5, 0.009);
    CHECK(gsf_draw_bits(1, 2, 3) == gsf_draw_bits(1, 2, 3));
    CHECK(gsf_draw_bits(1, 2, 3) != gsf_draw_bits(1, 3, 2) && gsf_draw_bits(1, 2, 3) != gsf_draw_bits(2, 1, 3));
}

static void test_chunks(gsf_context* ctx) {
    gsf_buffer file;
    memset(&file, 0, sizeof file);
    gsf_append_chunk(ctx, &file, "ONE ", "first", 5);
    gsf_append_chunk(ctx, &file, "TWO ", "", 0);
    gsf_append_chunk(ctx, &file, "TRE ", "third part", 10);
    gsf_append_last_chunk(ctx, &file);
    CHECK(!file.failed);

    const char* path = test_scratch("chunks.bin");
    CHECK_OK(ctx, gsf_write_file(ctx, path, file.data, file.size));
    void* data = NULL;
    size_t size = 0;
    CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
    CHECK(size == file.size && memcmp(data, file.data, size) == 0);
    CHECK_OK(ctx, gsf_check_chunks(ctx, "chunks", data, size));
    gsf_chunk chunk;
    CHECK(gsf_find_chunk(data, size, "TRE ", &chunk) && chunk.size == 10 && memcmp(chunk.data, "third part", 10) == 0);
    CHECK(gsf_find_chunk(data, size, "TWO ", &chunk) && chunk.size == 0);
    CHECK(!gsf_find_chunk(data, size, "NONE", &chunk));

    for (size_t cut = 0; cut < size; cut++) { // every truncation, in a block of exactly that size
        char* part = (char*)malloc(cut ? cut : 1);
        memcpy(part, data, cut);
        CHECK_RESULT(ctx, gsf_check_chunks(ctx, "cut", part, cut), GSF_ERROR_FORMAT);
        free(part);
    }
    for (size_t i = 0; i < size; i++) { // every byte changed
        ((unsigned char*)data)[i] ^= 0x41;
        CHECK(gsf_check_chunks(ctx, "flip", data, size) != GSF_OK);
        ((unsigned char*)data)[i] ^= 0x41;
    }
    gsf_free(ctx, data);
    gsf_destroy_buffer(ctx, &file);
}

static void test_files(gsf_context* ctx) {
    void* data = &data;
    size_t size = 1;
    const char* path = test_scratch("none/file.bin");
    CHECK_RESULT(ctx, gsf_read_file(ctx, path, &data, &size), GSF_ERROR_NOT_FOUND);
    CHECK(data == NULL && size == 0 && strstr(ctx->error, "none/file.bin") != NULL);
    CHECK_RESULT(ctx, gsf_write_file(ctx, path, "x", 1), GSF_ERROR_IO);
    path = test_scratch("empty.bin");
    CHECK_OK(ctx, gsf_write_file(ctx, path, "", 0));
    CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
    CHECK(data != NULL && size == 0);
    gsf_free(ctx, data);
#ifdef __linux__ // a full disk, here a limit on the size of files: the previous file survives, the temporary one does not
    path = test_scratch("kept.bin");
    CHECK_OK(ctx, gsf_write_file(ctx, path, "old", 3));
    struct rlimit was, small;
    CHECK(getrlimit(RLIMIT_FSIZE, &was) == 0);
    small = was;
    small.rlim_cur = 8;
    signal(SIGXFSZ, SIG_IGN);
    CHECK(setrlimit(RLIMIT_FSIZE, &small) == 0);
    CHECK_RESULT(ctx, gsf_write_file(ctx, path, "new content", 11), GSF_ERROR_IO);
    CHECK(setrlimit(RLIMIT_FSIZE, &was) == 0);
    CHECK(strstr(ctx->error, "kept.bin") != NULL);
    CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
    CHECK(size == 3 && memcmp(data, "old", 3) == 0);
    gsf_free(ctx, data);
    // A file with the temporary's name may belong to someone else, and so may the target of a link with that name.
    const char* temporary = test_scratch("kept.bin.tmp");
    const char* mine = test_scratch("mine.bin");
    remove(temporary);
    CHECK_OK(ctx, gsf_write_file(ctx, mine, "mine", 4));
    CHECK(symlink(mine, temporary) == 0);
    CHECK_OK(ctx, gsf_write_file(ctx, path, "new", 3));
    CHECK_OK(ctx, gsf_read_file(ctx, mine, &data, &size));
    CHECK(size == 4 && memcmp(data, "mine", 4) == 0);
    gsf_free(ctx, data);
    CHECK(remove(temporary) == 0);
    CHECK(access(test_scratch("kept.bin.tmp1"), F_OK) != 0);
#endif
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    const char* forced = getenv("GSF_TEST_CPU");
    if (forced && strcmp(forced, "scalar") == 0) CHECK(ctx.cpu_level == GSF_CPU_SCALAR);
    test_bad_hooks();
    test_memory(&ctx);
    test_random_numbers();
    test_chunks(&ctx);
    test_files(&ctx);
    gsf_request_cancel(&ctx);
    CHECK(gsf_is_cancelled(&ctx));
    gsf_clear_cancel(&ctx);
    CHECK(!gsf_is_cancelled(&ctx));
    return test_report();
}
