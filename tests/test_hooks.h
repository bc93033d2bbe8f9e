// test_hooks.h - hooks of tests that look at memory and warnings: an allocator that counts, and fails when told; a log that
// keeps the last warning.
#ifndef TEST_HOOKS_H
#define TEST_HOOKS_H

typedef struct counter { size_t live, calls, fail_at, asked; } counter; // fail_at: 1 = the first call; 0 = never

static void* counted_alloc(void* user, size_t size) {
    counter* c = (counter*)user;
    if (++c->calls == c->fail_at) return NULL;
    c->asked += size;
    void* p = malloc(size);
    if (p) c->live++;
    return p;
}
static void counted_free(void* user, void* memory) {
    if (memory) ((counter*)user)->live--;
    free(memory);
}

static char warning[1024]; // last one logged
static int warnings;
static inline void keep_warning(void* user, gsf_log_level level, const char* text) {
    (void)user;
    if (level != GSF_LOG_WARNING) return;
    snprintf(warning, sizeof warning, "%s", text);
    warnings++;
}

#endif
