// bench.h - shared by the benches: clocks, contexts, output rows, peaks of the machine. Include it after the
// implementation; BENCH_NAME ("splat") is written to every row.
#ifndef BENCH_H
#define BENCH_H

#include <time.h>

typedef struct bench_row {
    const char *name, *variant, *isa, *work_unit, *reference;
    int threads;
    double seconds, cpu_seconds, work, error_max, error_rel_l2; // errors < 0: not measured
    double flops, ops, bytes; // totals; ops: integer operations; 0: not counted or not a meaningful bound
    double bandwidth, cpu_bandwidth; // shares relative to reading the same memory between rounds; 0: relative to a sweep
    double peak_rss;     // bytes; 0: not measured
} bench_row;

enum { BENCH_LEVELS = GSF_CPU_SIMD128 + 1 };
static void bench_print(int json, const bench_row* row);

// Measured peaks per second, by instruction set and threads (1, 2): float32 multiply-adds, integer and bf16 dot products.
// 0: not measured or no instructions for it.
typedef struct bench_peak { double flops, ops, bf16; } bench_peak;
static bench_peak bench_peaks[BENCH_LEVELS][3];

#define BENCH_BF16 "bf16 products" // the variant whose shares are relative to the bf16 peak

static gsf_cpu_level bench_level_of(const char* isa) { // AUTO: unknown name
    int level = GSF_CPU_SCALAR;
    while (level < BENCH_LEVELS && strcmp(isa, gsf_describe_cpu_level((gsf_cpu_level)level)) != 0) level++;
    return level < BENCH_LEVELS ? (gsf_cpu_level)level : GSF_CPU_AUTO;
}

static const bench_peak* bench_peak_of(const char* isa, int threads) {
    return &bench_peaks[bench_level_of(isa)][threads < 2 ? 1 : 2];
}

static double bench_now(void) {
    struct timespec t;
    timespec_get(&t, TIME_UTC);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double bench_cpu(void) { return (double)clock() / CLOCKS_PER_SEC; }

static int bench_compare(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return (x > y) - (x < y);
}

// Inline: not every bench uses it; likewise below.
static inline double bench_median(double* values, size_t count) {
    qsort(values, count, sizeof *values, bench_compare);
    return count ? values[count / 2] : 0.0;
}

static bench_row bench_make_row(const char* name, gsf_cpu_level level, int threads, double seconds, double cpu_seconds,
                                double work, const char* work_unit) {
    bench_row row;
    memset(&row, 0, sizeof row);
    row.name = name;
    row.variant = "default";
    row.isa = gsf_describe_cpu_level(level);
    row.threads = threads;
    row.seconds = seconds;
    row.cpu_seconds = cpu_seconds;
    row.work = work;
    row.work_unit = work_unit;
    row.reference = "none";
    row.error_max = row.error_rel_l2 = -1.0;
    return row;
}

static void bench_require(gsf_context* ctx, gsf_result result) {
    if (result == GSF_OK) return;
    fprintf(stderr, "bench_" BENCH_NAME ": %s (%s)\n", ctx->error, gsf_describe_result(result));
    exit(1);
}

static int bench_context(gsf_context* ctx, gsf_cpu_level level, int threads) { // 0: the machine lacks the instructions
    memset(ctx, 0, sizeof *ctx);
    ctx->cpu_level = level;
    ctx->threads = threads;
    bench_require(ctx, gsf_init_context(ctx));
    return ctx->cpu_level == level;
}

static void* bench_alloc(gsf_context* ctx, size_t count, size_t size) {
    void* memory = gsf_alloc(ctx, count, size);
    if (!memory) bench_require(ctx, GSF_ERROR_OUT_OF_MEMORY);
    return memory;
}

// ---- multiply-adds: a chunk runs FMA_CHAINS * FMA_ROUNDS per lane and writes 16 floats --------------------------------

enum { FMA_CHAINS = 10, FMA_ROUNDS = 1 << 22 };

static float bench_sink; // keeps the compiler from dropping the loops

#define BENCH_TEN(f) f(0) f(1) f(2) f(3) f(4) f(5) f(6) f(7) f(8) f(9) // an array would be kept in memory at -O2

// The compiler vectorizes scalar code, too, with the baseline vectors of the architecture (SSE2, Neon).
typedef float bench_baseline __attribute__((vector_size(16)));

static void bench_fma_scalar(void* arg, size_t chunk,
                             int32_t worker) { // multiply and add; there is no fused one without AVX2
    const bench_baseline a = {0.999f, 0.999f, 0.999f, 0.999f}, b = {0.001f, 0.001f, 0.001f, 0.001f};
    (void)worker;
#define BENCH_SCALAR(k) bench_baseline v##k = {(float)k, (float)k, (float)k, (float)k};
    BENCH_TEN(BENCH_SCALAR)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_SCALAR_STEP(k) v##k = v##k * a + b;
        BENCH_TEN(BENCH_SCALAR_STEP)
    }
    const bench_baseline sum = v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9;
    memcpy((float*)arg + 16 * chunk, &sum, sizeof sum);
}

#if GSF__X86
GSF__TARGET_AVX2 static void bench_fma_avx2(void* arg, size_t chunk, int32_t worker) {
    const __m256 a = _mm256_set1_ps(0.999f), b = _mm256_set1_ps(0.001f);
    (void)worker;
#define BENCH_VECTOR(k) __m256 v##k = _mm256_set1_ps((float)k);
    BENCH_TEN(BENCH_VECTOR)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_VECTOR_STEP(k) v##k = _mm256_fmadd_ps(v##k, a, b);
        BENCH_TEN(BENCH_VECTOR_STEP)
    }
    _mm256_storeu_ps((float*)arg + 16 * chunk, v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9);
}

GSF__TARGET_AVX512 static void bench_fma_avx512(void* arg, size_t chunk, int32_t worker) {
    const __m512 a = _mm512_set1_ps(0.999f), b = _mm512_set1_ps(0.001f);
    (void)worker;
#define BENCH_WIDE(k) __m512 v##k = _mm512_set1_ps((float)k);
    BENCH_TEN(BENCH_WIDE)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_WIDE_STEP(k) v##k = _mm512_fmadd_ps(v##k, a, b);
        BENCH_TEN(BENCH_WIDE_STEP)
    }
    _mm512_storeu_ps((float*)arg + 16 * chunk, v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9);
}
#endif

static inline gsf_chunk_fn bench_fma_of(gsf_cpu_level level, double* flops) { // flops: per step
#if GSF__X86
    *flops = level >= GSF_CPU_AVX512 ? 32.0 : level >= GSF_CPU_AVX2 ? 16.0 : 8.0;
    if (level >= GSF_CPU_AVX512) return bench_fma_avx512;
    if (level >= GSF_CPU_AVX2) return bench_fma_avx2;
#endif
    (void)level;
    *flops = 8.0;
    return bench_fma_scalar;
}

// The fastest of nine rounds with `chunks` per thread, by wall clock or by CPU time, whichever is higher.
static double bench_fastest(gsf_context* ctx, size_t chunks, gsf_chunk_fn body, void* arg) {
    double best = 1e30;
    for (int i = 0; i < 9; i++) {
        const double wall = bench_now(), cpu = bench_cpu();
        gsf__parallel_for(ctx, chunks * (size_t)ctx->threads, body, arg);
        const double by_wall = bench_now() - wall, by_cpu = (bench_cpu() - cpu) / ctx->threads;
        best = fmin(best, by_cpu > 0.0 ? fmin(by_wall, by_cpu) : by_wall);
    }
    return best;
}

// Runs a loop of FMA_CHAINS * FMA_ROUNDS steps of `work` each, prints the row and returns the rate.
static inline double bench_peak_rate(int json, gsf_context* ctx, const char* name, gsf_chunk_fn body, double work,
                                     const char* unit) {
    float sums[4 * 2 * 16];
    const double seconds = bench_fastest(ctx, 4, body, sums), all = work * FMA_CHAINS * (double)FMA_ROUNDS * 4.0 * ctx->threads;
    const bench_row row = bench_make_row(name, ctx->cpu_level, ctx->threads, seconds, seconds * ctx->threads, all, unit);
    bench_sink += sums[0];
    bench_print(json, &row);
    return all / seconds;
}

// ---- memory: a sweep over a buffer, each thread over its part --------------------------
//
// SWEEP_READ reads four rows side by side. How long they should be beyond the caches, and how far ahead to fetch, depends on
// the processor: over 1 GiB 64 KiB and 2 KiB on Sapphire Rapids (4 to 6 % faster than rows of 4 KiB or quarters of the part),
// 256 KiB and 0 to 1 KiB on Zen 4 (13 % faster than 64 KiB and 2 KiB). So that is measured.

typedef enum bench_sweep_kind { SWEEP_READ, SWEEP_UPDATE, SWEEP_COPY, SWEEP_STREAM, SWEEP_KINDS } bench_sweep_kind;
enum { SWEEP_WAYS = 5, SWEEP_STEP = 1 << 20, SWEEP_CACHES = 1 << 23 }; // STEP, CACHES: bytes
static const size_t bench_sweep_ways[SWEEP_WAYS][2] = { // bytes: of a row, and fetched ahead
    {1 << 16, 0}, {1 << 16, 512}, {1 << 16, 2048}, {1 << 18, 0}, {1 << 18, 512}};

typedef struct bench_sweep {
    char* memory;    // 64-byte aligned
    size_t part;     // bytes per thread, a power of two or a multiple of SWEEP_STEP
    int passes;      // consecutive passes over the part
    int way;         // SWEEP_READ: one of bench_sweep_ways
    bench_sweep_kind kind; // read; update in place; copy the first half to the second, through the caches or streaming
    float sums[2 * 16];
} bench_sweep;

// BODY(load, store, stream) for one instruction set, given V, WIDTH and XOR.
#define BENCH_SWEEP_BODY(V, LOAD, STORE, STREAM, XOR, ZERO)                                                              \
    bench_sweep* job = (bench_sweep*)arg;                                                                                \
    char* p = job->memory + chunk * job->part;                                                                           \
    const size_t half = job->part / 2, *way = bench_sweep_ways[job->way], fetch = way[1];                                \
    const size_t row = job->part < 4 * way[0] ? job->part / 4 : way[0];                                                  \
    V a = ZERO, b = ZERO, c = ZERO, d = ZERO;                                                                            \
    (void)worker;                                                                                                        \
    for (int pass = 0; pass < job->passes; pass++) {                                                                     \
        if (job->kind == SWEEP_READ)                                                                                     \
            for (size_t q = 0; q < job->part; q += 4 * row)                                                              \
                for (size_t i = q; i < q + row; i += sizeof(V)) {                                                        \
                    for (size_t k = 0; k < 4 && fetch; k++) __builtin_prefetch(p + i + k * row + fetch);                 \
                    a = XOR(a, LOAD(p + i));                                                                             \
                    b = XOR(b, LOAD(p + i + row));                                                                       \
                    c = XOR(c, LOAD(p + i + 2 * row));                                                                   \
                    d = XOR(d, LOAD(p + i + 3 * row));                                                                   \
                }                                                                                                        \
        else if (job->kind == SWEEP_UPDATE)                                                                              \
            for (size_t i = 0; i < job->part; i += 2 * sizeof(V)) {                                                      \
                STORE(p + i, XOR(a, LOAD(p + i)));                                                                       \
                STORE(p + i + sizeof(V), XOR(a, LOAD(p + i + sizeof(V))));                                               \
            }                                                                                                            \
        else if (job->kind == SWEEP_COPY)                                                                                \
            for (size_t i = 0; i < half; i += sizeof(V)) STORE(p + half + i, LOAD(p + i));                               \
        else                                                                                                             \
            for (size_t i = 0; i < half; i += sizeof(V)) STREAM(p + half + i, LOAD(p + i));                              \
        __asm__ volatile("" ::: "memory"); /* keeps every pass    */                                                     \
    }                                                                                                                    \
    const V sum = XOR(XOR(a, b), XOR(c, d));                                                                             \
    memcpy(job->sums + 16 * chunk, &sum, sizeof(float));

typedef uint32_t bench_bits __attribute__((vector_size(16)));

static void bench_sweep_scalar(void* arg, size_t chunk, int32_t worker) {
#define BENCH_LOAD(q) (*(const bench_bits*)(const void*)(q))
#define BENCH_STORE(q, v) (*(bench_bits*)(void*)(q) = (v))
#define BENCH_XOR(x, y) ((x) ^ (y))
    const bench_bits zero = {0, 0, 0, 0};
    BENCH_SWEEP_BODY(bench_bits, BENCH_LOAD, BENCH_STORE, BENCH_STORE, BENCH_XOR, zero)
#undef BENCH_LOAD
#undef BENCH_STORE
#undef BENCH_XOR
}

#if GSF__X86
GSF__TARGET_AVX2 static void bench_sweep_avx2(void* arg, size_t chunk, int32_t worker) {
#define BENCH_LOAD(q) _mm256_load_ps((const float*)(const void*)(q))
#define BENCH_STORE(q, v) _mm256_store_ps((float*)(void*)(q), v)
#define BENCH_STREAM(q, v) _mm256_stream_ps((float*)(void*)(q), v)
    BENCH_SWEEP_BODY(__m256, BENCH_LOAD, BENCH_STORE, BENCH_STREAM, _mm256_xor_ps, _mm256_setzero_ps())
#undef BENCH_LOAD
#undef BENCH_STORE
#undef BENCH_STREAM
}

GSF__TARGET_AVX512 static void bench_sweep_avx512(void* arg, size_t chunk, int32_t worker) {
#define BENCH_LOAD(q) _mm512_load_ps((const float*)(const void*)(q))
#define BENCH_STORE(q, v) _mm512_store_ps((float*)(void*)(q), v)
#define BENCH_STREAM(q, v) _mm512_stream_ps((float*)(void*)(q), v)
    BENCH_SWEEP_BODY(__m512, BENCH_LOAD, BENCH_STORE, BENCH_STREAM, _mm512_xor_ps, _mm512_setzero_ps())
#undef BENCH_LOAD
#undef BENCH_STORE
#undef BENCH_STREAM
}
#endif

static gsf_chunk_fn bench_sweep_of(gsf_cpu_level level) {
#if GSF__X86
    if (level >= GSF_CPU_AVX512) return bench_sweep_avx512;
    if (level >= GSF_CPU_AVX2) return bench_sweep_avx2;
#endif
    (void)level;
    return bench_sweep_scalar;
}

// Reads each thread's part once.
static void bench_read_all(gsf_context* ctx, bench_sweep* read) {
    gsf__parallel_for(ctx, (size_t)ctx->threads, bench_sweep_of(ctx->cpu_level), read);
    bench_sink += read->sums[0];
}

static void bench_choose_way(gsf_context* ctx, bench_sweep* read) { // the fastest; within the caches, nothing is fetched
    double best = 1e30;
    int fastest = 0;
    for (int i = 0; i < 3 * SWEEP_WAYS && read->part > SWEEP_CACHES; i++) {
        read->way = i % SWEEP_WAYS;
        const double start = bench_now();
        bench_read_all(ctx, read);
        const double seconds = bench_now() - start;
        if (seconds >= best) continue;
        best = seconds;
        fastest = read->way;
    }
    read->way = fastest;
}

enum { SWEEP_SMALLEST = 16, SWEEP_LARGEST = 28 }; // log2 of bytes
static double bench_sweep_rates[BENCH_LEVELS][3][SWEEP_LARGEST + 1];

// Bytes per second of the fastest kind of sweep over 2^size bytes: the limit for a case that touches at least as many. A
// write counts once, even if the cache line is read first.
static double bench_sweep_rate(int json, gsf_cpu_level level, int threads, int size) {
    double* rate = &bench_sweep_rates[level][threads][size];
    gsf_context ctx;
    if (*rate > 0.0 || !bench_context(&ctx, level, threads)) return *rate;
    const size_t bytes = (size_t)1 << size;
    char* block = (char*)bench_alloc(&ctx, bytes + 64, 1);
    memset(block, 1, bytes + 64);
    bench_sweep sweep;
    memset(&sweep, 0, sizeof sweep);
    sweep.memory = block + (64 - (uintptr_t)block % 64) % 64;
    sweep.part = bytes / (size_t)threads;
    sweep.passes = bytes < (1 << 24) ? (int)((1 << 24) / bytes) : 1;
    bench_choose_way(&ctx, &sweep);
    for (int kind = 0; kind < SWEEP_KINDS; kind++) {
        sweep.kind = (bench_sweep_kind)kind;
        const double moved = (kind == SWEEP_UPDATE ? 2.0 : 1.0) * (double)bytes * sweep.passes;
        *rate = fmax(*rate, moved / bench_fastest(&ctx, 1, bench_sweep_of(level), &sweep));
    }
    bench_sink += sweep.sums[0];
    gsf_free(&ctx, block);
    char name[64];
    snprintf(name, sizeof name, "machine: sweep over %g %s", size < 20 ? bytes / 1024.0 : bytes / 1048576.0,
             size < 20 ? "KiB" : "MiB");
    const double seconds = (double)bytes / *rate;
    const bench_row row = bench_make_row(name, level, threads, seconds, seconds * threads, (double)bytes, "B");
    bench_print(json, &row);
    return *rate;
}

// The limit for a case that transfers `bytes`: it touches at least half of them (each read and written), and a larger
// buffer is never faster.
static double bench_bandwidth(int json, gsf_cpu_level level, int threads, double bytes) {
    int size = SWEEP_SMALLEST;
    while (size < SWEEP_LARGEST && (double)((size_t)2 << size) <= 0.5 * bytes) size++;
    return bench_sweep_rate(json, level, threads, size);
}

// ---- rows ----------------------------------------------------------------------------

// Shares are relative to the limits by wall clock; those with cpu_ use rates by CPU time, for machines that are not idle.
// Rows without a limit have no share.
typedef struct bench_shares { double peak, bandwidth, cpu_bandwidth; const char* of; } bench_shares;

static bench_shares bench_shares_of(int json, const bench_row* row, double cpu) {
    bench_shares s = {0.0, row->bandwidth, row->cpu_bandwidth, "FMA"};
    const bench_peak* peak = bench_peak_of(row->isa, row->threads);
    const int bf16 = strcmp(row->variant, BENCH_BF16) == 0;
    const double limit = row->ops > 0.0 ? peak->ops : bf16 ? peak->bf16 : peak->flops;
    if (row->ops > 0.0) s.of = "integer";
    else if (bf16) s.of = "bf16";
    if (limit > 0.0) s.peak = (row->ops > 0.0 ? row->ops : row->flops) / row->seconds / limit;
    if (row->bytes > 0.0 && s.bandwidth <= 0.0) {
        s.bandwidth = row->bytes / row->seconds / bench_bandwidth(json, bench_level_of(row->isa), row->threads, row->bytes);
        s.cpu_bandwidth = cpu * s.bandwidth;
    }
    return s;
}

static void bench_print(int json, const bench_row* row) {
    const double rate = row->seconds > 0.0 ? row->work / row->seconds : 0.0;
    const double cpu = row->cpu_seconds > 0.0 ? row->seconds * row->threads / row->cpu_seconds : 0.0;
    const bench_shares share = bench_shares_of(json, row, cpu);
    if (json) {
        printf("{\"bench\":\"" BENCH_NAME "\",\"case\":\"%s\",\"variant\":\"%s\",\"isa\":\"%s\",\"threads\":%d,"
               "\"seconds\":%.6g,"
               "\"cpu_seconds\":%.6g,\"work\":%.6g,\"work_unit\":\"%s\",\"rate\":%.6g,\"reference\":\"%s\"",
               row->name, row->variant, row->isa, row->threads, row->seconds, row->cpu_seconds, row->work, row->work_unit,
               rate, row->reference);
        if (share.peak > 0.0)
            printf(",\"peak\":\"%s\",\"peak_share\":%.4g,\"cpu_peak_share\":%.4g", share.of, share.peak, cpu * share.peak);
        if (row->bytes > 0.0)
            printf(",\"bytes\":%.6g,\"bandwidth_share\":%.4g,\"cpu_bandwidth_share\":%.4g", row->bytes, share.bandwidth,
                   share.cpu_bandwidth);
        if (row->peak_rss > 0.0) printf(",\"peak_rss_bytes\":%.0f", row->peak_rss);
        if (row->error_max >= 0.0) printf(",\"error_max\":%.3g,\"error_rel_l2\":%.3g", row->error_max, row->error_rel_l2);
        printf("}\n");
    } else {
        printf("%-44s %-8s %-6s %d thr %9.3f ms %9.3f ms cpu %9.4g %s/s", row->name, row->variant, row->isa, row->threads,
               1e3 * row->seconds, 1e3 * row->cpu_seconds, rate, row->work_unit);
        if (share.peak > 0.0)
            printf("  %.1f%% (cpu %.1f%%) of the %s peak", 100.0 * share.peak, 100.0 * cpu * share.peak, share.of);
        if (row->bytes > 0.0)
            printf("  %.1f%% (cpu %.1f%%) of bandwidth", 100.0 * share.bandwidth, 100.0 * share.cpu_bandwidth);
        if (row->peak_rss > 0.0) printf("  %.0f MiB at most", row->peak_rss / (1 << 20));
        if (row->error_max >= 0.0) printf("  max %.2g  rel L2 %.2g", row->error_max, row->error_rel_l2);
        printf("\n");
    }
    fflush(stdout);
}

#endif
