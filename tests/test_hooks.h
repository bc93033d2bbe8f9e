// test_hooks.h - hooks for tests of memory, warnings and workers: an allocator that counts and fails on demand; a log that
// keeps the last warning; workers that process chunks in another order; copies without room behind them.
#ifndef TEST_HOOKS_H
#define TEST_HOOKS_H

// fail_at: 1 = the first call, 0 = never; stays: all later calls fail, too
typedef struct counter { size_t live, calls, fail_at, asked; int stays; } counter;

static inline void* counted_alloc(void* user, size_t size) {
    counter* c = (counter*)user;
    if (++c->calls == c->fail_at || (c->stays && c->fail_at && c->calls > c->fail_at)) return NULL;
    c->asked += size;
    void* p = malloc(size);
    if (p) c->live++;
    return p;
}
static inline void counted_free(void* user, void* memory) {
    if (memory) ((counter*)user)->live--;
    free(memory);
}
static inline void count_memory(gsf_context* ctx, counter* c) {
    ctx->allocator.alloc_fn = counted_alloc;
    ctx->allocator.free_fn = counted_free;
    ctx->allocator.user = c;
}

static char warning[1024]; // last one logged
static int warnings;
static inline void keep_warning(void* user, gsf_log_level level, const char* text) {
    (void)user;
    if (level != GSF_LOG_WARNING) return;
    snprintf(warning, sizeof warning, "%s", text);
    warnings++;
}

static inline void* exact_copy(const void* data, size_t size) { // so that ASan detects a read one byte past the end
    void* p = malloc(size);
    if (p && size) memcpy(p, data, size);
    return p;
}

// Backwards, with workers in rotation, so that scratch memory left by other chunks is reused.
static inline void backwards(void* user, size_t count, gsf_chunk_fn body, void* arg) {
    (void)user;
    for (size_t i = count; i-- > 0;) body(arg, i, (int)(i % 3));
}
static inline void work_backwards(gsf_context* ctx) {
    ctx->parallel.for_fn = backwards;
    ctx->parallel.worker_count = 3;
}

#endif
