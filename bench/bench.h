// bench.h - what the benches share: clocks, contexts, rows of output, the processor's multiply-adds. Included behind the
// implementation; BENCH_NAME ("splat") goes into every row.
#ifndef BENCH_H
#define BENCH_H

#include <time.h>

typedef struct bench_row {
    const char *name, *variant, *isa, *work_unit, *reference;
    int threads;
    double seconds, cpu_seconds, work, error_max, error_rel_l2; // errors < 0: not measured
    double flops, ops, bytes; // of the whole; ops: with integers; 0: not counted, or not the bound to look at
    double bandwidth, cpu_bandwidth; // shares of what reading the same memory between the rounds gave; 0: not measured
    double peak_rss;     // bytes; 0: not measured
} bench_row;

enum { BENCH_LEVELS = GSF_CPU_AVX512_BF16 + 1 };

typedef struct bench_peak { double flops, ops, bytes; } bench_peak; // per second
static bench_peak bench_peaks[BENCH_LEVELS][3]; // by instruction set and threads (1, 2)

static gsf_cpu_level bench_level_of(const char* isa) { // AUTO: there is no such set
    int level = GSF_CPU_SCALAR;
    while (level < BENCH_LEVELS && strcmp(isa, gsf_cpu_level_name((gsf_cpu_level)level)) != 0) level++;
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

static double bench_median(double* values, size_t count) {
    qsort(values, count, sizeof *values, bench_compare);
    return count ? values[count / 2] : 0.0;
}

static bench_row bench_make_row(const char* name, gsf_cpu_level level, int threads, double seconds, double cpu_seconds,
                                double work, const char* work_unit) {
    bench_row row;
    memset(&row, 0, sizeof row);
    row.name = name;
    row.variant = "default";
    row.isa = gsf_cpu_level_name(level);
    row.threads = threads;
    row.seconds = seconds;
    row.cpu_seconds = cpu_seconds;
    row.work = work;
    row.work_unit = work_unit;
    row.reference = "none";
    row.error_max = row.error_rel_l2 = -1.0;
    return row;
}

// Shares are of the peaks by the clock; cpu_... ones make rates by CPU time of rates by the clock, for machines that do other
// things as well.
static void bench_print(int json, const bench_row* row) {
    const double rate = row->seconds > 0.0 ? row->work / row->seconds : 0.0;
    const bench_peak* peak = bench_peak_of(row->isa, row->threads);
    const double flop_peak = row->ops > 0.0 ? peak->ops : peak->flops, work = row->ops > 0.0 ? row->ops : row->flops;
    const double flop_share = flop_peak > 0.0 ? work / row->seconds / flop_peak : 0.0;
    const double of_peak = peak->bytes > 0.0 ? row->bytes / row->seconds / peak->bytes : 0.0;
    const double cpu = row->cpu_seconds > 0.0 ? row->seconds * row->threads / row->cpu_seconds : 0.0;
    const double byte_share = row->bandwidth > 0.0 ? row->bandwidth : of_peak;
    const double cpu_byte_share = row->bandwidth > 0.0 ? row->cpu_bandwidth : cpu * of_peak;
    if (json) {
        printf("{\"bench\":\"" BENCH_NAME "\",\"case\":\"%s\",\"variant\":\"%s\",\"isa\":\"%s\",\"threads\":%d,\"seconds\":%.6g,"
               "\"cpu_seconds\":%.6g,\"work\":%.6g,\"work_unit\":\"%s\",\"rate\":%.6g,\"reference\":\"%s\"",
               row->name, row->variant, row->isa, row->threads, row->seconds, row->cpu_seconds, row->work, row->work_unit,
               rate, row->reference);
        if (work > 0.0) printf(",\"peak_share\":%.4g,\"cpu_peak_share\":%.4g", flop_share, cpu * flop_share);
        if (row->bytes > 0.0)
            printf(",\"bytes\":%.6g,\"bandwidth_share\":%.4g,\"cpu_bandwidth_share\":%.4g", row->bytes, byte_share,
                   cpu_byte_share);
        if (row->peak_rss > 0.0) printf(",\"peak_rss_bytes\":%.0f", row->peak_rss);
        if (row->error_max >= 0.0) printf(",\"error_max\":%.3g,\"error_rel_l2\":%.3g", row->error_max, row->error_rel_l2);
        printf("}\n");
    } else {
        printf("%-44s %-8s %-6s %d thr %9.3f ms %9.3f ms cpu %9.4g %s/s", row->name, row->variant, row->isa, row->threads,
               1e3 * row->seconds, 1e3 * row->cpu_seconds, rate, row->work_unit);
        if (work > 0.0)
            printf("  %.1f%% (cpu %.1f%%) of the %s peak", 100.0 * flop_share, 100.0 * cpu * flop_share,
                   row->ops > 0.0 ? "integer" : "FMA");
        if (row->bytes > 0.0) printf("  %.1f%% (cpu %.1f%%) of bandwidth", 100.0 * byte_share, 100.0 * cpu_byte_share);
        if (row->peak_rss > 0.0) printf("  %.0f MiB at most", row->peak_rss / (1 << 20));
        if (row->error_max >= 0.0) printf("  max %.2g  rel L2 %.2g", row->error_max, row->error_rel_l2);
        printf("\n");
    }
    fflush(stdout);
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

// ---- multiply-adds: a chunk does FMA_CHAINS * FMA_ROUNDS of them in each lane, and writes 16 floats ----------------

enum { FMA_CHAINS = 10, FMA_ROUNDS = 1 << 22 };

static float bench_sink; // keeps the compiler from dropping the loops

#define BENCH_TEN(f) f(0) f(1) f(2) f(3) f(4) f(5) f(6) f(7) f(8) f(9) // an array would lie in memory at -O2

static void bench_fma_scalar(void* arg, size_t chunk, int worker) { // multiply and add: no fused one without AVX2
    (void)worker;
#define BENCH_SCALAR(k) float v##k = (float)k;
    BENCH_TEN(BENCH_SCALAR)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_SCALAR_STEP(k) v##k = v##k * 0.999f + 0.001f;
        BENCH_TEN(BENCH_SCALAR_STEP)
    }
    ((float*)arg)[16 * chunk] = v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9;
}

#if GSF__X86
GSF__TARGET_AVX2 static void bench_fma_avx2(void* arg, size_t chunk, int worker) {
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

GSF__TARGET_AVX512 static void bench_fma_avx512(void* arg, size_t chunk, int worker) {
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

static gsf_chunk_fn bench_fma_of(gsf_cpu_level level, double* lanes) {
    *lanes = 1.0;
#if GSF__X86
    if (level >= GSF_CPU_AVX512) {
        *lanes = 16.0;
        return bench_fma_avx512;
    }
    if (level >= GSF_CPU_AVX2) {
        *lanes = 8.0;
        return bench_fma_avx2;
    }
#endif
    (void)level;
    return bench_fma_scalar;
}

#endif
