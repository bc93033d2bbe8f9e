// bench_nn.c - run time and error of the network kernels.
// By hand: cc -O2 -fopenmp -I. bench/bench_nn.c -o bench_nn -lm
//
//     bench_nn [--json] [--quick] [--filter TEXT] [--threads N] [--isa NAME]
//              [--model FOLDER | --pipeline FOLDER... | --mini FILE]
//
// Measures the machine's peaks (multiply-adds, integer and bf16 dot products per second; memory bandwidth by size of the
// buffer, when first needed), then every kernel at the sizes of the released model and at a small size, for each
// instruction set, with one and two threads. Shares are relative to the peak of the same instruction set and number of
// threads; bandwidth is relative to a sweep over as much memory or, for GEMV cases, which cycle through 1 GiB of
// weights, to reading the same memory between rounds. Errors are relative to sums in double, over a sample of rows for
// large shapes. bench/peers_nn.py runs PyTorch on the same cases, which it parses from their names. Seconds are the
// median of the rounds; cpu_seconds, the CPU time of all threads, is their minimum. Peaks are also measured by CPU
// time: on a machine that is not idle, cpu_peak_share is the more reliable figure. --model instead runs a model's VAE
// and one forward pass of its transformer once, at the configured size: seconds, operations and peak anonymous memory
// (make_model writes such a folder; the released size takes hours here). --pipeline restores a clip with a small model,
// with every solver, fewer steps and each option that skips work: run time and error of the frames. Further folders
// hold the same weights in other dtypes. --mini times a frame of the restorer mini with these weights.
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#define GSF_ASSERT(x) ((void)0)
#include "../gsfixer_nn.h"

#include <pthread.h>
#include <stdatomic.h>

#define BENCH_NAME "nn"
#include "bench.h"

typedef struct bench_options {
    int json, quick, threads;
    gsf_cpu_level level; // for all but the smallest cases, which run at every level
    const char *filter, *model, *mini, *pipelines[4];
    int pipeline_count;
} bench_options;

// All instruction sets; bench_context skips those that the machine lacks.
#define BENCH_EACH(level) \
    for (gsf_cpu_level level = GSF_CPU_SCALAR; level <= bench_best_level; level = (gsf_cpu_level)(level + 1))
static gsf_cpu_level bench_best_level;

static int bench_wanted(const bench_options* o, const char* name, int threads) {
    return (!o->filter || strstr(name, o->filter)) && (!o->threads || o->threads == threads);
}

// ---- peaks of the machine -------------------------------------------------------

// Reads `size` bytes of `memory` once.
static bench_sweep bench_make_read(const gsf_context* ctx, char* memory, size_t size) {
    bench_sweep read;
    memset(&read, 0, sizeof read);
    read.memory = memory;
    read.part = size / (size_t)ctx->threads / SWEEP_STEP * SWEEP_STEP;
    read.passes = 1;
    return read;
}

// Integers: in each 32-bit lane, one dot product per step, of four bytes if the processor has instructions for it, else
// of two 16-bit words.

#if GSF__X86
// prevents the compiler from merging the chains
#define BENCH_DOT_STEP(k) v##k = BENCH_DOT(v##k); __asm__("" : "+v"(v##k));
GSF__TARGET_AVX2 static void bench_dot_avx2(void* arg, size_t chunk, int32_t worker) {
    const __m256i a = _mm256_set1_epi32(0x10001);
    (void)worker;
#define BENCH_INTEGERS(k) __m256i v##k = _mm256_set1_epi32(k);
    BENCH_TEN(BENCH_INTEGERS)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_DOT(v) _mm256_madd_epi16(v, a)
        BENCH_TEN(BENCH_DOT_STEP)
#undef BENCH_DOT
    }
    const __m256i sum = v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9;
    _mm256_storeu_si256((__m256i*)(void*)((float*)arg + 16 * chunk), sum);
}

#define BENCH_WIDE_INTEGERS(k) __m512i v##k = _mm512_set1_epi32(k);
#define BENCH_STORE_INTEGERS                                                                \
    const __m512i sum = v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9;                    \
    _mm512_storeu_si512((float*)arg + 16 * chunk, sum);
GSF__TARGET_AVX512 static void bench_dot_avx512(void* arg, size_t chunk, int32_t worker) {
    const __m512i a = _mm512_set1_epi32(0x10001);
    (void)worker;
    BENCH_TEN(BENCH_WIDE_INTEGERS)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_DOT(v) _mm512_madd_epi16(v, a)
        BENCH_TEN(BENCH_DOT_STEP)
#undef BENCH_DOT
    }
    BENCH_STORE_INTEGERS
}

GSF__TARGET_VNNI static void bench_dot_vnni(void* arg, size_t chunk, int32_t worker) {
    const __m512i a = _mm512_set1_epi32(0x1010101);
    (void)worker;
    BENCH_TEN(BENCH_WIDE_INTEGERS)
    for (int i = 0; i < FMA_ROUNDS; i++) {
#define BENCH_DOT(v) _mm512_dpbusd_epi32(v, a, a)
        BENCH_TEN(BENCH_DOT_STEP)
#undef BENCH_DOT
    }
    BENCH_STORE_INTEGERS
}

GSF__TARGET_BF16 static void bench_dot_bf16(void* arg, size_t chunk, int32_t worker) { // of pairs in each 32-bit lane
    const __m512bh a = (__m512bh)_mm512_set1_epi16(0x3f80);
    (void)worker;
#define BENCH_WIDE_PAIRS(k) __m512 v##k = _mm512_set1_ps((float)k), w##k = _mm512_set1_ps((float)k + 32.0f);
    BENCH_TEN(BENCH_WIDE_PAIRS)
    for (int i = 0; i < FMA_ROUNDS / 2; i++) { // latency exceeds that of multiply-adds, so twice as many chains
#define BENCH_PAIRS_STEP(k) v##k = _mm512_dpbf16_ps(v##k, a, a); w##k = _mm512_dpbf16_ps(w##k, a, a);
        BENCH_TEN(BENCH_PAIRS_STEP)
    }
    v0 = v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7 + v8 + v9;
    _mm512_storeu_ps((float*)arg + 16 * chunk, v0 + w0 + w1 + w2 + w3 + w4 + w5 + w6 + w7 + w8 + w9);
}
#endif

#if GSF__AMX
// Products of tiles that are loaded once: four in a sixteenth of the rounds
#define BENCH_TILES(name, multiply)                                      \
    GSF__TARGET_AMX static void name(void* arg, size_t chunk, int32_t worker) { \
        memset((float*)arg + 16 * chunk, 0, 16 * sizeof(float));         \
        (void)worker;                                                    \
        gsf__enter_tiles();                                              \
        _tile_zero(4);                                                   \
        _tile_zero(5);                                                   \
        for (int i = 0; i < FMA_ROUNDS / 16; i++) {                      \
            multiply(0, 4, 5);                                           \
            multiply(1, 4, 5);                                           \
            multiply(2, 4, 5);                                           \
            multiply(3, 4, 5);                                           \
        }                                                                \
        gsf__leave_tiles();                                              \
    }
BENCH_TILES(bench_tiles_bf16, _tile_dpbf16ps)
BENCH_TILES(bench_tiles_int8, _tile_dpbusd)
#define BENCH_TILE_WORK (4.0 / 16 / FMA_CHAINS * 2 * 16 * 16) // times the values of a row, per step of bench_peak_rate
#endif

static gsf_chunk_fn bench_dot_of(gsf_cpu_level level, double* ops) { // ops: per step; NULL: no instructions for it
#if GSF__AMX
    *ops = 64 * BENCH_TILE_WORK;
    if (level == GSF_CPU_AMX) return bench_tiles_int8;
#endif
#if GSF__X86
    *ops = level >= GSF_CPU_AVX512_VNNI ? 128.0 : level >= GSF_CPU_AVX512 ? 64.0 : 32.0;
    if (level >= GSF_CPU_AVX512_VNNI) return bench_dot_vnni;
    if (level >= GSF_CPU_AVX512) return bench_dot_avx512;
    if (level >= GSF_CPU_AVX2) return bench_dot_avx2;
#endif
    (void)level;
    *ops = 0.0;
    return NULL;
}

static void bench_machine(const bench_options* o, gsf_cpu_level level, int threads) {
    gsf_context ctx;
    double work;
    if (!bench_context(&ctx, level, threads)) return;
    bench_peak* peak = &bench_peaks[level][threads];
    const gsf_chunk_fn fma = bench_fma_of(level, &work);
    peak->flops = bench_peak_rate(o->json, &ctx, "machine: multiply-add", fma, work, "flop");
    const gsf_chunk_fn dot = bench_dot_of(level, &work);
    if (dot) peak->ops = bench_peak_rate(o->json, &ctx, "machine: integer dot products", dot, work, "op");
#if GSF__AMX
    if (level == GSF_CPU_AMX)
        peak->bf16 = bench_peak_rate(o->json, &ctx, "machine: bf16 dot products", bench_tiles_bf16, 32 * BENCH_TILE_WORK,
                                     "flop");
#endif
#if GSF__X86
    if (level == GSF_CPU_AVX512_BF16)
        peak->bf16 = bench_peak_rate(o->json, &ctx, "machine: bf16 dot products", bench_dot_bf16, 64.0, "flop");
#endif
}

// ---- time ------------------------------------------------------------------------

typedef void (*bench_body)(gsf_context* ctx, void* arg);

// One warm-up round, then at least three rounds, for about a second (quick: 0.2 s). Each runs `repeats` units of the
// row. If `read` is set, that memory is read before each round, in the fastest way, and the row's bandwidth is relative to
// the bandwidth of these reads: other users of the memory bus then affect both alike.
static void bench_time_beside(const bench_options* o, gsf_context* ctx, bench_row* row, bench_body body, void* arg,
                              double repeats, bench_sweep* read) {
    enum { MOST = 101 };
    double wall[MOST], cpu[MOST], share[MOST], cpu_share[MOST];
    if (read) bench_choose_way(ctx, read);
    const double start = bench_now(), budget = o->quick ? 0.3 : read ? 3.0 : 1.5;
    int rounds = -1;
    while (rounds < MOST && (rounds < 3 || bench_now() - start < budget)) {
        const double before = bench_now(), cpu_before = bench_cpu();
        if (read) bench_read_all(ctx, read);
        const double t = bench_now(), c = bench_cpu();
        body(ctx, arg);
        if (rounds >= 0) {
            wall[rounds] = (bench_now() - t) / repeats;
            cpu[rounds] = (bench_cpu() - c) / repeats;
            share[rounds] = (t - before) / repeats / wall[rounds];
            cpu_share[rounds] = (c - cpu_before) / repeats / cpu[rounds];
        }
        rounds++;
    }
    row->seconds = bench_median(wall, (size_t)rounds);
    const double part = read ? row->bytes * repeats / ((double)read->part * ctx->threads) : 0.0;
    row->bandwidth = part * bench_median(share, (size_t)rounds);
    row->cpu_bandwidth = part * bench_median(cpu_share, (size_t)rounds);
    qsort(cpu, (size_t)rounds, sizeof *cpu, bench_compare);
    row->cpu_seconds = cpu[0];
}

static void bench_time(const bench_options* o, gsf_context* ctx, bench_row* row, bench_body body, void* arg,
                       double repeats) {
    bench_time_beside(o, ctx, row, body, arg, repeats, NULL);
}

// ---- synthetic values -------------------------------------------------------------

static uint64_t bench_random(uint64_t* state) { // xorshift64
    uint64_t x = *state;
    x ^= x << 13;
    x ^= x >> 7;
    x ^= x << 17;
    return *state = x;
}

// Values of either sign with magnitudes in [1/4, 1/2). Each 16 or 32 bits hold one value.
static void bench_fill(void* memory, size_t bytes, gsf_nn_dtype dtype, uint64_t seed) {
    static const uint64_t keeps[] = {0x807fffff807fffffu, 0x807f807f807f807fu, 0x83ff83ff83ff83ffu}; // f32, bf16, f16
    static const uint64_t sets[] = {0x3e8000003e800000u, 0x3e803e803e803e80u, 0x3400340034003400u};
    const uint64_t keep = keeps[dtype], set = sets[dtype];
    uint64_t state = seed * 0x9e3779b97f4a7c15u + 1;
    for (size_t i = 0; i < bytes; i += 8) {
        const uint64_t bits = (bench_random(&state) & keep) | set;
        memcpy((char*)memory + i, &bits, bytes - i < 8 ? bytes - i : 8);
    }
}

// ---- linear layers ----------------------------------------------------------------

typedef struct bench_linear {
    gsf__nn_linear_desc desc;
    gsf_nn_tensor weight, bias;
    gsf__nn_workspace workspace;
    int64_t in, out, copies; // copies of the weights, contiguous: a round uses each once
} bench_linear;

static void bench_run_linear(gsf_context* ctx, void* arg) {
    bench_linear* l = (bench_linear*)arg;
    const char* first = (const char*)l->weight.data;
    for (int64_t i = 0; i < l->copies; i++) {
        l->weight.data = first + (size_t)i * (size_t)l->weight.count * gsf_nn_get_dtype_size(l->weight.dtype);
        bench_require(ctx, gsf__nn_run_linear(ctx, &l->workspace, &l->desc));
    }
    l->weight.data = first;
}

static double bench_activation(gsf__nn_activation activation, double x) {
    if (activation == GSF__NN_GELU_TANH) return 0.5 * x * (1.0 + tanh(0.7978845608028654 * (x + 0.044715 * x * x * x)));
    return activation == GSF__NN_SILU ? x / (1.0 + exp(-x)) : x;
}

// Error relative to sums in double, over at most 4 rows: the last, the first and some between. y holds one call's
// results.
static void bench_linear_error(const bench_linear* l, const float* w, const float* bias, bench_row* row) {
    const gsf__nn_linear_desc* d = &l->desc;
    double worst = 0.0, difference = 0.0, square = 0.0;
    const int64_t looks = d->rows < 4 ? d->rows : 4;
    for (int64_t i = 0; i < looks; i++) {
        const int64_t m = looks == 1 ? 0 : i * (d->rows - 1) / (looks - 1);
        for (int64_t n = 0; n < l->out; n++) {
            double sum = bias ? (double)bias[n] : 0.0;
            for (int64_t k = 0; k < l->in; k++) sum += (double)d->x[m * l->in + k] * (double)w[n * l->in + k];
            const double value = bench_activation(d->activation, sum), error = fabs((double)d->y[m * l->out + n] - value);
            if (!(error <= worst)) worst = error;
            difference += error * error;
            square += value * value;
        }
    }
    row->error_max = worst;
    row->error_rel_l2 = sqrt(difference / square);
    row->reference = "float64";
}

// Products of bf16 pairs are a separate variant if the processor has instructions for them.
static int bench_has_bf16(const bench_options* o, gsf_nn_dtype weights) {
    return o->level >= GSF_CPU_AVX512_BF16 && weights == GSF_NN_BF16;
}

// `memory` holds `size` bytes for the weights; GEMV cases cycle through all of it.
static void bench_one_linear(const bench_options* o, gsf_cpu_level level, int threads, gsf_nn_dtype dtype, int bf16,
                             int64_t rows, int64_t out, int64_t in, gsf__nn_activation activation, char* memory,
                             size_t size) {
    static const char* const dtypes[] = {"f32", "bf16", "f16"};
    static const char* const activations[] = {"", " gelu", " silu"};
    char name[96];
    snprintf(name, sizeof name, "linear %s M=%lld N=%lld K=%lld%s", dtypes[dtype], (long long)rows, (long long)out,
             (long long)in, activations[activation]);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, level, threads)) return;
    bench_linear l;
    memset(&l, 0, sizeof l);
    l.in = in;
    l.out = out;
    const size_t bytes = (size_t)in * (size_t)out * gsf_nn_get_dtype_size(dtype);
    l.copies = rows <= GSF__GEMV_ROWS ? (int64_t)(size / bytes) : 1;
    bench_fill(memory, l.copies > 1 ? size : bytes, dtype, 1);
    l.weight.name = "weight";
    l.weight.data = memory;
    l.weight.dtype = dtype;
    l.weight.rank = 2;
    l.weight.shape[0] = out;
    l.weight.shape[1] = in;
    l.weight.count = in * out;
    float* x = (float*)bench_alloc(&ctx, (size_t)(rows * in), sizeof(float));
    float* y = (float*)bench_alloc(&ctx, (size_t)(rows * out), sizeof(float));
    float* bias = (float*)bench_alloc(&ctx, (size_t)out, sizeof(float));
    bench_fill(x, (size_t)(rows * in) * sizeof(float), GSF_NN_F32, 2);
    bench_fill(bias, (size_t)out * sizeof(float), GSF_NN_F32, 3);
    l.bias = gsf_nn_wrap_tensor("bias", bias, 1, &out);
    l.desc.x = x;
    l.desc.rows = rows;
    l.desc.weight = &l.weight;
    l.desc.bias = &l.bias;
    l.desc.activation = activation;
    l.desc.y = y;
    l.desc.bf16 = bf16;
    const double flops = 2.0 * (double)rows * (double)in * (double)out;
    const int few = rows <= GSF__GEMV_ROWS;
    bench_row row = bench_make_row(name, level, threads, 0.0, 0.0, few ? (double)bytes : flops, few ? "B" : "flop");
    if (few) row.bytes = (double)bytes;
    else row.flops = flops;
    if (bf16) row.variant = BENCH_BF16;
    bench_sweep read = bench_make_read(&ctx, memory, (size_t)l.copies * bytes);
    bench_time_beside(o, &ctx, &row, bench_run_linear, &l, (double)l.copies, few ? &read : NULL);
    l.copies = 1;
    bench_run_linear(&ctx, &l);
    float* wide = (float*)bench_alloc(&ctx, (size_t)(in * out), sizeof(float));
    gsf_nn_convert_tensor(&l.weight, 0, in * out, wide);
    bench_linear_error(&l, wide, bias, &row);
    bench_print(o->json, &row);
    gsf_free(&ctx, wide);
    gsf_free(&ctx, bias);
    gsf_free(&ctx, y);
    gsf_free(&ctx, x);
    gsf__nn_destroy_workspace(&ctx, &l.workspace);
}

typedef struct bench_shape {
    int64_t rows, out, in;
    gsf__nn_activation activation;
    int quick; // also measured with --quick
} bench_shape;

static void bench_linears(const bench_options* o, char* memory, size_t size) {
    static const bench_shape shapes[] = {
        {1, 3072, 3072, GSF__NN_LINEAR, 1},     {2, 3072, 3072, GSF__NN_LINEAR, 0},
        {4, 3072, 3072, GSF__NN_LINEAR, 1},     {2, 18432, 512, GSF__NN_LINEAR, 0},
        {226, 3072, 3072, GSF__NN_LINEAR, 1},   {2048, 3072, 3072, GSF__NN_LINEAR, 1},
        {2048, 12288, 3072, GSF__NN_GELU_TANH, 0}, {2048, 3072, 12288, GSF__NN_LINEAR, 0},
        {17776, 3072, 3072, GSF__NN_LINEAR, 0},
    };
    static const gsf_nn_dtype dtypes[] = {GSF_NN_F32, GSF_NN_BF16, GSF_NN_F16};
    for (int threads = 1; threads <= 2; threads++)
        for (size_t t = 0; t < GSF__COUNT(dtypes); t++) {
            BENCH_EACH(level) bench_one_linear(o, level, threads, dtypes[t], 0, 64, 256, 256, GSF__NN_LINEAR, memory,
                                               size);
            for (size_t i = 0; i < GSF__COUNT(shapes); i++) {
                const bench_shape* s = &shapes[i];
                if (o->quick && !s->quick) continue;
                for (int bf16 = 0; bf16 <= bench_has_bf16(o, dtypes[t]) && (!bf16 || s->rows > GSF__GEMV_ROWS); bf16++)
                    bench_one_linear(o, o->level, threads, dtypes[t], bf16, s->rows, s->out, s->in, s->activation, memory,
                                     size);
            }
        }
}

// ---- 8-bit linear layers --------------------------------------------------------------

typedef struct bench_int8 {
    bench_linear linear; // copies: of the quantized weights
    gsf__nn_quantized weight;
} bench_int8;

static void bench_run_int8(gsf_context* ctx, void* arg) {
    bench_int8* l = (bench_int8*)arg;
    gsf__nn_quantized weight = l->weight;
    for (int64_t i = 0; i < l->linear.copies; i++) {
        bench_require(ctx, gsf__nn_run_linear_int8(ctx, &l->linear.workspace, &l->linear.desc, &weight));
        weight.data += weight.bytes;
    }
}

static void bench_run_quantize(gsf_context* ctx, void* arg) {
    bench_int8* l = (bench_int8*)arg;
    gsf__nn_destroy_quantized(ctx, &l->weight);
    bench_require(ctx, gsf__nn_quantize_weight(ctx, &l->linear.weight, 0, &l->weight));
}

// Float input; the time includes rotation, rounding, product, scales and bias. Errors include those of the
// quantization.
static void bench_one_int8(const bench_options* o, gsf_cpu_level level, int threads, int64_t rows, int64_t out, int64_t in,
                           char* memory, size_t size) {
    char name[96];
    snprintf(name, sizeof name, "linear int8 M=%lld N=%lld K=%lld", (long long)rows, (long long)out, (long long)in);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, level, threads)) return;
    bench_int8 l;
    memset(&l, 0, sizeof l);
    const int64_t shape[2] = {out, in};
    l.linear.in = in;
    l.linear.out = out;
    float* w = (float*)(void*)memory;
    bench_fill(w, (size_t)(in * out) * sizeof(float), GSF_NN_F32, 1);
    l.linear.weight = gsf_nn_wrap_tensor("weight", w, 2, shape);
    float* x = (float*)bench_alloc(&ctx, (size_t)(rows * in), sizeof(float));
    float* y = (float*)bench_alloc(&ctx, (size_t)(rows * out), sizeof(float));
    float* bias = (float*)bench_alloc(&ctx, (size_t)out, sizeof(float));
    bench_fill(x, (size_t)(rows * in) * sizeof(float), GSF_NN_F32, 2);
    bench_fill(bias, (size_t)out * sizeof(float), GSF_NN_F32, 3);
    l.linear.bias = gsf_nn_wrap_tensor("bias", bias, 1, &out);
    l.linear.desc.x = x;
    l.linear.desc.rows = rows;
    l.linear.desc.bias = &l.linear.bias;
    l.linear.desc.y = y;
    l.linear.copies = 1;
    bench_run_quantize(&ctx, &l);
    bench_run_int8(&ctx, &l);
    const int few = rows <= GSF__GEMV_ROWS;
    const double ops = 2.0 * (double)rows * (double)in * (double)out, bytes = (double)l.weight.bytes;
    bench_row row = bench_make_row(name, level, threads, 0.0, 0.0, few ? bytes : ops, few ? "B" : "op");
    bench_linear_error(&l.linear, w, bias, &row);
    if (few) {
        bench_int8 many = l; // copies of the weights that fill the memory
        many.weight.data = (int8_t*)(void*)memory;
        many.linear.copies = (int64_t)(size / l.weight.bytes);
        for (int64_t i = 0; i < many.linear.copies; i++)
            memcpy(memory + (size_t)i * l.weight.bytes, l.weight.data, l.weight.bytes);
        bench_sweep read = bench_make_read(&ctx, memory, (size_t)many.linear.copies * l.weight.bytes);
        row.bytes = bytes;
        bench_time_beside(o, &ctx, &row, bench_run_int8, &many, (double)many.linear.copies, &read);
    } else {
        row.ops = ops;
        bench_time(o, &ctx, &row, bench_run_int8, &l, 1.0);
    }
    bench_print(o->json, &row);
    if (rows == 2048) {
        snprintf(name, sizeof name, "linear int8 weights N=%lld K=%lld", (long long)out, (long long)in);
        row = bench_make_row(name, level, threads, 0.0, 0.0, (double)in * (double)out, "weight");
        row.bytes = (double)in * (double)out * sizeof(float) + (double)l.weight.bytes;
        bench_time(o, &ctx, &row, bench_run_quantize, &l, 1.0);
        bench_print(o->json, &row);
    }
    gsf_free(&ctx, bias);
    gsf_free(&ctx, y);
    gsf_free(&ctx, x);
    gsf__nn_destroy_quantized(&ctx, &l.weight);
    gsf__nn_destroy_workspace(&ctx, &l.linear.workspace);
}

static void bench_int8s(const bench_options* o, char* memory, size_t size) {
    static const bench_shape shapes[] = {
        {1, 3072, 3072, GSF__NN_LINEAR, 1},    {2, 3072, 3072, GSF__NN_LINEAR, 0},    {4, 3072, 3072, GSF__NN_LINEAR,
                                                                                       1},
        {226, 3072, 3072, GSF__NN_LINEAR, 0},  {2048, 3072, 3072, GSF__NN_LINEAR, 1},
        {2048, 12288, 3072, GSF__NN_LINEAR, 0}, {2048, 3072, 12288, GSF__NN_LINEAR, 0}, {17776, 3072, 3072,
                                                                                         GSF__NN_LINEAR, 0},
    };
    for (int threads = 1; threads <= 2; threads++) {
        BENCH_EACH(level) bench_one_int8(o, level, threads, 64, 256, 256, memory, size);
        for (size_t i = 0; i < GSF__COUNT(shapes); i++)
            if (!o->quick || shapes[i].quick)
                bench_one_int8(o, o->level, threads, shapes[i].rows, shapes[i].out, shapes[i].in, memory,
                               size);
    }
}

// ---- attention ----------------------------------------------------------------------

typedef struct bench_attention {
    gsf__nn_attention_desc desc;
    gsf__nn_workspace workspace;
} bench_attention;

static void bench_run_attention(gsf_context* ctx, void* arg) {
    bench_attention* a = (bench_attention*)arg;
    bench_require(ctx, gsf__nn_run_attention(ctx, &a->workspace, &a->desc));
}

// Error_rel_l2 accumulates squares.
static void bench_add_error(bench_row* row, double value, double expected, double* square) {
    const double error = fabs(value - expected);
    if (!(error <= row->error_max)) row->error_max = error;
    row->error_rel_l2 += error * error;
    *square += expected * expected;
}

// Error relative to sums in double: three queries of the first and of the last head.
static void bench_attention_error(gsf_context* ctx, const gsf__nn_attention_desc* d, bench_row* row) {
    double *p = (double*)bench_alloc(ctx, (size_t)d->keys, sizeof(double)), square = 0.0;
    const int64_t dim = d->head_dim, width = d->heads * dim;
    row->error_max = row->error_rel_l2 = 0.0;
    for (int look = 0; look < 6; look++) {
        const int64_t r = look % 3 * (d->queries - 1) / 2, column = look < 3 ? 0 : width - dim;
        double top = -INFINITY, sum = 0.0;
        for (int64_t j = 0; j < d->keys; j++) {
            p[j] = 0.0;
            for (int64_t i = 0; i < dim; i++)
                p[j] += (double)d->q[r * width + column + i] * (double)d->k[j * width + column + i] / sqrt((double)dim);
            top = fmax(top, p[j]);
        }
        for (int64_t j = 0; j < d->keys; j++) sum += p[j] = exp(p[j] - top);
        for (int64_t i = 0; i < dim; i++) {
            double value = 0.0;
            for (int64_t j = 0; j < d->keys; j++) value += p[j] * (double)d->v[j * width + column + i];
            bench_add_error(row, (double)d->out[r * width + column + i], value / sum, &square);
        }
    }
    row->error_rel_l2 = sqrt(row->error_rel_l2 / square);
    row->reference = "float64";
    gsf_free(ctx, p);
}

static void bench_one_attention(const bench_options* o, gsf_cpu_level level, int threads, int bf16, int32_t heads,
                                int64_t queries, int64_t keys) {
    char name[96];
    snprintf(name, sizeof name, "attention f32 H=%d D=64 Q=%lld K=%lld", (int)heads, (long long)queries, (long long)keys);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, level, threads)) return;
    const size_t q_size = (size_t)queries * (size_t)heads * 64, k_size = (size_t)keys * (size_t)heads * 64;
    float* memory = (float*)bench_alloc(&ctx, 2 * q_size + 2 * k_size, sizeof(float));
    bench_fill(memory, (2 * q_size + 2 * k_size) * sizeof(float), GSF_NN_F32, 4);
    for (size_t i = 0; i < q_size + k_size; i++) memory[i] *= 4.0f; // as after a norm: logits of small magnitude
    bench_attention a;
    memset(&a, 0, sizeof a);
    a.desc.queries = queries;
    a.desc.keys = keys;
    a.desc.heads = heads;
    a.desc.head_dim = 64;
    a.desc.q = memory;
    a.desc.k = memory + q_size;
    a.desc.v = memory + q_size + k_size;
    a.desc.out = memory + q_size + 2 * k_size;
    a.desc.bf16 = bf16;
    const double flops = 4.0 * (double)queries * (double)keys * (double)heads * 64.0;
    bench_row row = bench_make_row(name, level, threads, 0.0, 0.0, flops, "flop");
    row.flops = flops;
    if (bf16) row.variant = BENCH_BF16;
    bench_time(o, &ctx, &row, bench_run_attention, &a, 1.0);
    bench_attention_error(&ctx, &a.desc, &row);
    bench_print(o->json, &row);
    gsf__nn_destroy_workspace(&ctx, &a.workspace);
    gsf_free(&ctx, memory);
}

static void bench_attentions(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        BENCH_EACH(level) bench_one_attention(o, level, threads, 0, 4, 64, 256);
        for (int bf16 = 0; bf16 <= bench_has_bf16(o, GSF_NN_BF16); bf16++) {
            bench_one_attention(o, o->level, threads, bf16, 48, 1024, 1024);
            if (o->quick) continue;
            bench_one_attention(o, o->level, threads, bf16, 48, 4096, 4096);
            bench_one_attention(o, o->level, threads, bf16, 48, 17550, 1850);
        }
    }
}

// ---- norms and activations ----------------------------------------------------------

typedef enum bench_kind { LAYER_NORM, MODULATED, RMS_NORM, HEAD_NORM, GROUP_NORM, SOFTMAX, GELU, SILU, KINDS } bench_kind;

typedef struct bench_rows {
    bench_kind kind;
    int64_t rows, dim; // group norm: channels, values per channel
    const float *x, *vector, *table; // vector: used as weight, bias, scale and shift; table: cosines and sines
    float* y;
} bench_rows;

enum { BENCH_GROUPS = 32, BENCH_HEAD = 64 };

static void bench_run_rows(gsf_context* ctx, void* arg) {
    const bench_rows* b = (const bench_rows*)arg;
    const float* v = b->vector;
    switch (b->kind) {
        case LAYER_NORM: gsf__nn_layer_norm(ctx, b->x, b->rows, b->dim, v, v, 1e-6f, b->y); break;
        case MODULATED: gsf__nn_layer_norm_modulated(ctx, b->x, b->rows, b->dim, v, v, 1e-6f, v, v, b->y); break;
        case RMS_NORM: gsf__nn_rms_norm(ctx, b->x, b->rows, b->dim, v, 1e-6f, b->y); break;
        case HEAD_NORM:
            gsf__nn_head_norm_rope(ctx, b->y, b->rows, b->dim, (int32_t)(b->dim / BENCH_HEAD), BENCH_HEAD, v, v, 1e-6f,
                                   b->table, b->table, 0);
            break;
        case GROUP_NORM: gsf__nn_group_norm(ctx, b->x, b->rows, b->dim, BENCH_GROUPS, v, v, 1e-6f, b->y); break;
        case SOFTMAX: gsf__nn_softmax(ctx, b->x, b->rows, b->dim, 1.0f, b->y); break;
        case GELU: gsf__nn_activate(ctx, GSF__NN_GELU_TANH, b->x, b->rows * b->dim, b->y); break;
        default: gsf__nn_activate(ctx, GSF__NN_SILU, b->x, b->rows * b->dim, b->y); break;
    }
}

// The first `n` values of the result in double precision: a row, a group or a head.
static void bench_expect_rows(const bench_rows* b, int64_t n, double* out) {
    double mean = 0.0, square = 0.0, sum = 0.0;
    for (int64_t i = 0; i < n; i++) mean += (double)b->x[i] / (double)n;
    if (b->kind == RMS_NORM) mean = 0.0;
    for (int64_t i = 0; i < n; i++) square += ((double)b->x[i] - mean) * ((double)b->x[i] - mean) / (double)n;
    for (int64_t i = 0; i < n; i++) sum += exp((double)b->x[i]);
    for (int64_t i = 0; i < n; i++) {
        const double w = (double)b->vector[b->kind == GROUP_NORM ? i / b->dim : i], x = (double)b->x[i];
        out[i] = (x - mean) / sqrt(square + 1e-6) * w + (b->kind == RMS_NORM ? 0.0 : w);
        if (b->kind == MODULATED) out[i] = out[i] * (1.0 + w) + w;
        if (b->kind == SOFTMAX) out[i] = exp(x) / sum;
        if (b->kind >= GELU) out[i] = bench_activation(b->kind == GELU ? GSF__NN_GELU_TANH : GSF__NN_SILU, x);
    }
    for (int64_t i = 0; b->kind == HEAD_NORM && i < n; i += 2) {
        const double first = out[i], second = out[i + 1];
        out[i] = first * (double)b->table[i] - second * (double)b->table[i];
        out[i + 1] = second * (double)b->table[i + 1] + first * (double)b->table[i + 1];
    }
}

static void bench_one_rows(const bench_options* o, gsf_cpu_level level, int threads, bench_kind kind, int64_t rows,
                           int64_t dim) {
    static const char* const names[KINDS] = {"layer_norm", "layer_norm_modulated", "rms_norm", "head_norm_rope",
                                             "group_norm", "softmax",              "gelu",     "silu"};
    char name[96];
    snprintf(name, sizeof name, "%s f32 %lldx%lld", names[kind], (long long)rows, (long long)dim);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, level, threads)) return;
    const size_t count = (size_t)rows * (size_t)dim, vectors = (size_t)(kind == GROUP_NORM ? rows : dim);
    const size_t tables = kind == HEAD_NORM ? (size_t)rows * BENCH_HEAD : 0;
    float* memory = (float*)bench_alloc(&ctx, 2 * count + vectors + tables, sizeof(float));
    bench_fill(memory, (2 * count + vectors + tables) * sizeof(float), GSF_NN_F32, 5);
    for (size_t i = 0; i < count; i++) memory[i] *= 4.0f;
    bench_rows b;
    b.kind = kind;
    b.rows = rows;
    b.dim = dim;
    b.x = memory;
    b.y = memory + count;
    b.vector = memory + 2 * count;
    b.table = memory + 2 * count + vectors;
    const int64_t looks = kind == GROUP_NORM ? rows / BENCH_GROUPS * dim : kind == HEAD_NORM ? BENCH_HEAD : dim;
    double *expected = (double*)bench_alloc(&ctx, (size_t)looks, sizeof(double)), square = 0.0;
    const double bytes = 2.0 * (double)count * sizeof(float); // read once, written once
    bench_row row = bench_make_row(name, level, threads, 0.0, 0.0, bytes, "B");
    row.bytes = bytes;
    memcpy(b.y, b.x, count * sizeof(float)); // head norm works in place
    bench_run_rows(&ctx, &b);
    bench_expect_rows(&b, looks, expected);
    row.error_max = row.error_rel_l2 = 0.0;
    for (int64_t i = 0; i < looks; i++) bench_add_error(&row, (double)b.y[i], expected[i], &square);
    row.error_rel_l2 = sqrt(row.error_rel_l2 / square);
    row.reference = "float64";
    bench_time(o, &ctx, &row, bench_run_rows, &b, 1.0);
    bench_print(o->json, &row);
    gsf_free(&ctx, expected);
    gsf_free(&ctx, memory);
}

static void bench_norms(const bench_options* o) {
    const int64_t tokens = o->quick ? 2048 : 17776;
    for (int threads = 1; threads <= 2; threads++)
        for (int kind = 0; kind < KINDS; kind++) {
            int64_t rows = tokens, dim = 3072;
            if (kind == GROUP_NORM) { rows = 128; dim = o->quick ? 57600 : 345600; }
            if (kind == SOFTMAX) { rows = o->quick ? 512 : 4096; dim = 17776; }
            if (kind == GELU || kind == SILU) dim = 12288;
            BENCH_EACH(level) bench_one_rows(o, level, threads, (bench_kind)kind, 64, 256);
            bench_one_rows(o, o->level, threads, (bench_kind)kind, rows, dim);
        }
}

// ---- convolutions -------------------------------------------------------------------

typedef struct bench_conv {
    gsf__nn_conv_desc desc;
    gsf_nn_tensor weight;
    gsf__nn_workspace workspace;
    int64_t channels;
} bench_conv;

static void bench_run_conv(gsf_context* ctx, void* arg) {
    bench_conv* c = (bench_conv*)arg;
    bench_require(ctx, gsf__nn_convolve(ctx, &c->workspace, &c->desc));
}

// Output n of pixel (t, y, x), as a direct sum in double.
static double bench_conv_value(const bench_conv* c, const float* w, int64_t t, int64_t y, int64_t x, int64_t n) {
    const gsf__nn_conv_desc* d = &c->desc;
    double sum = 0.0;
    for (int64_t tap = 0; tap < 27; tap++) {
        const int64_t from = t - 2 + tap / 9, row = y - 1 + tap / 3 % 3, column = x - 1 + tap % 3;
        if (row < 0 || column < 0 || row >= d->height || column >= d->width) continue;
        const float* in = d->x + (((from < 0 ? 0 : from) * d->height + row) * d->width + column) * c->channels;
        for (int64_t i = 0; i < c->channels; i++) sum += (double)in[i] * (double)w[(n * c->channels + i) * 27 + tap];
    }
    return sum;
}

static void bench_conv_error(const bench_conv* c, const float* w, bench_row* row) {
    enum { LOOKS = 64 };
    const gsf__nn_conv_desc* d = &c->desc;
    const int64_t count = d->frames * d->height * d->width * c->channels;
    double worst = 0.0, difference = 0.0, square = 0.0;
    for (int64_t i = 0; i < LOOKS; i++) { // includes the first and the last value
        const int64_t at = i * (count - 1) / (LOOKS - 1), pixel = at / c->channels;
        const double value = bench_conv_value(c, w, pixel / d->width / d->height, pixel / d->width % d->height,
                                              pixel % d->width, at % c->channels);
        const double error = fabs((double)d->y[at] - value);
        if (!(error <= worst)) worst = error;
        difference += error * error;
        square += value * value;
    }
    row->error_max = worst;
    row->error_rel_l2 = sqrt(difference / square);
    row->reference = "float64";
}

// Causal 3 x 3 x 3 convolution over `frames` of height x width, channels last, with equal numbers of inputs and outputs.
static void bench_one_conv(const bench_options* o, gsf_cpu_level level, int threads, int64_t channels, int64_t frames,
                           int64_t height, int64_t width) {
    char name[96];
    snprintf(name, sizeof name, "conv3d f32 C=%lld T=%lld H=%lld W=%lld", (long long)channels, (long long)frames,
             (long long)height, (long long)width);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, level, threads)) return;
    bench_conv c;
    memset(&c, 0, sizeof c);
    const size_t values = (size_t)(frames * height * width * channels), weights = (size_t)(channels * channels * 27);
    const int64_t shape[5] = {channels, channels, 3, 3, 3};
    float* x = (float*)bench_alloc(&ctx, values, sizeof(float));
    float* y = (float*)bench_alloc(&ctx, values, sizeof(float));
    float* w = (float*)bench_alloc(&ctx, weights, sizeof(float));
    bench_fill(x, values * sizeof(float), GSF_NN_F32, 1);
    bench_fill(w, weights * sizeof(float), GSF_NN_F32, 2);
    c.channels = channels;
    c.weight = gsf_nn_wrap_tensor("weight", w, 5, shape);
    c.desc.x = x;
    c.desc.y = y;
    c.desc.frames = frames;
    c.desc.height = height;
    c.desc.width = width;
    c.desc.weight = &c.weight;
    bench_row row = bench_make_row(name, level, threads, 0.0, 0.0, 54.0 * (double)values * (double)channels, "flop");
    row.flops = row.work;
    bench_time(o, &ctx, &row, bench_run_conv, &c, 1.0);
    bench_conv_error(&c, w, &row);
    bench_print(o->json, &row);
    gsf_free(&ctx, w);
    gsf_free(&ctx, y);
    gsf_free(&ctx, x);
    gsf__nn_destroy_workspace(&ctx, &c.workspace);
}

// ---- the autoencoder's resnet block: two convolutions with fused group norm and SiLU on their input

typedef struct bench_resnet {
    gsf__vae_net net;
    gsf__vae_resnet resnet;
    gsf__vae_run run;
    gsf__vae_map x;
    gsf_nn_tensor weight, ones;
} bench_resnet;

static void bench_run_resnet(gsf_context* ctx, void* arg) {
    bench_resnet* r = (bench_resnet*)arg;
    gsf__vae_map x = r->x;
    r->run.ctx = ctx;
    bench_require(ctx, gsf__vae_resnet_run(&r->run, &r->resnet, &x));
}

static void bench_one_resnet(const bench_options* o, int threads, int64_t channels, int64_t frames, int64_t height,
                             int64_t width) {
    char name[96];
    snprintf(name, sizeof name, "vae resnet C=%lld T=%lld H=%lld W=%lld", (long long)channels, (long long)frames,
             (long long)height, (long long)width);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    bench_resnet r;
    memset(&r, 0, sizeof r);
    const int64_t shape[5] = {channels, channels, 3, 3, 3};
    const size_t values = (size_t)(frames * height * width * channels), weights = (size_t)(channels * channels * 27);
    float* w = (float*)bench_alloc(&ctx, weights + (size_t)channels, sizeof(float));
    bench_fill(w, weights * sizeof(float), GSF_NN_F32, 2);
    for (int64_t i = 0; i < channels; i++) w[weights + (size_t)i] = 1.0f;
    for (size_t i = 0; i < weights; i++) w[i] *= 2.0f / sqrtf((float)channels * 27.0f);
    r.weight = gsf_nn_wrap_tensor("weight", w, 5, shape);
    r.ones = gsf_nn_wrap_tensor("ones", w + weights, 1, shape);
    const gsf__conv_layer conv = {&r.weight, &r.ones, channels, channels, 3, 3, 1};
    r.resnet.conv1 = r.resnet.conv2 = conv;
    r.resnet.norm1.weight = r.resnet.norm1.bias = r.resnet.norm2.weight = r.resnet.norm2.bias = &r.ones;
    r.resnet.norm1.eps = r.resnet.norm2.eps = 1e-6;
    r.net.groups = 32;
    r.net.causal_count = 2;
    r.run.ctx = &ctx;
    r.run.net = &r.net;
    r.run.chunks = 1;
    r.x.frames = frames;
    r.x.height = height;
    r.x.width = width;
    r.x.channels = channels;
    bench_require(&ctx, gsf__vae_begin(&r.run));
    bench_require(&ctx, gsf__vae_grow(&r.run, &r.run.slots[0], (int64_t)values));
    bench_fill(r.run.slots[0].data, values * sizeof(float), GSF_NN_F32, 1);
    for (int64_t g = 0; g < 2 * r.net.groups; g++) // the sums that such inputs would have given: mean 0, deviation 3/8
        gsf__vae_sums(&r.run, 0)[g] = g % 2 ? 0.140625 * (double)values / 32.0 : 0.0;
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, 2.0 * 54.0 * (double)values * (double)channels, "flop");
    row.flops = row.work;
    bench_time(o, &ctx, &row, bench_run_resnet, &r, 1.0);
    bench_print(o->json, &row);
    gsf__vae_end(&r.run);
    gsf_free(&ctx, w);
}

static void bench_convs(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        BENCH_EACH(level) bench_one_conv(o, level, threads, 32, 4, 20, 30);
        if (!o->quick) bench_one_conv(o, o->level, threads, 512, 4, 60, 90);
        bench_one_conv(o, o->level, threads, 128, o->quick ? 1 : 4, o->quick ? 60 : 240, o->quick ? 90 : 360);
        bench_one_resnet(o, threads, 128, o->quick ? 1 : 4, o->quick ? 60 : 240, o->quick ? 90 : 360);
    }
}

// ---- weights of a block, by its table ------------------------------------------------

typedef struct bench_weights {
    gsf_nn_tensor tensors[64];
    size_t count, used; // used: size in bytes
    gsf_nn_dtype dtype;
    char* memory;       // NULL: only determine the size
} bench_weights;

// Values that keep the magnitude of the residual stream: [1/4, 1/2) in vectors; in matrices fixed exponent
// bits limit magnitudes to 1/128.
static gsf_result bench_add_weight(void* user, const char* name, int32_t rank, const int64_t* shape,
                                   const gsf_nn_tensor** to) {
    bench_weights* w = (bench_weights*)user;
    gsf_nn_tensor* t = &w->tensors[w->count++];
    memset(t, 0, sizeof *t);
    t->name = name[0] ? "weight" : name;
    t->dtype = w->dtype;
    t->rank = rank;
    t->count = 1;
    for (int32_t i = 0; i < rank; i++) t->count *= t->shape[i] = shape[i];
    t->data = w->memory + w->used;
    const size_t bytes = (size_t)t->count * gsf_nn_get_dtype_size(t->dtype);
    if (w->memory) {
        char* data = w->memory + w->used;
        bench_fill(data, bytes, t->dtype, w->count);
        for (size_t k = 1; rank > 1 && t->dtype != GSF_NN_F16 && k < bytes; k += 2)
            if (t->dtype == GSF_NN_BF16 || k % 4 == 3) data[k] = (char)((data[k] & 0x80) | 0x3b);
    }
    *to = t;
    w->used += (bytes + 63) / 64 * 64;
    return GSF_OK;
}

// Fills the struct at `where` with the tensors of `entries`; returns their memory, which the caller frees.
static char* bench_make_weights(gsf_context* ctx, bench_weights* w, gsf_nn_dtype dtype, const gsf__nn_sizes* sizes,
                                const gsf__nn_entry* entries, void* where) {
    for (int pass = 0; pass < 2; pass++) {
        char* memory = pass ? (char*)bench_alloc(ctx, w->used, 1) : NULL;
        memset(w, 0, sizeof *w);
        w->dtype = dtype;
        w->memory = memory;
        bench_require(ctx, gsf__nn_visit(sizes, entries, "", where, bench_add_weight, w));
    }
    return w->memory;
}

// ---- gradients ------------------------------------------------------------------------

typedef struct bench_gradient { // of one layer; unused ones are zero
    gsf__nn_attention_desc attention;
    gsf__nn_attention_grad_desc attention_grad;
    gsf__nn_linear_grad_desc linear;
    gsf__nn_conv_desc conv;
    gsf__nn_conv_grad_desc conv_grad;
    gsf_nn_tensor weight;
} bench_gradient;

static void bench_run_gradient(gsf_context* ctx, void* arg) {
    const bench_gradient* g = (const bench_gradient*)arg;
    if (g->attention.q) bench_require(ctx, gsf__nn_attention_grad(ctx, &g->attention_grad));
    else if (g->linear.x) bench_require(ctx, gsf__nn_linear_grad(ctx, NULL, &g->linear));
    else bench_require(ctx, gsf__nn_conv_grad(ctx, &g->conv_grad));
}

// dq of three queries of the last head, in double.
static double bench_attention_grad_error(gsf_context* ctx, const bench_gradient* g, bench_row* row) {
    const gsf__nn_attention_desc* d = &g->attention;
    const int64_t dim = d->head_dim, width = d->heads * dim, column = width - dim;
    double *p = (double*)bench_alloc(ctx, 2 * (size_t)d->keys, sizeof(double)), *dp = p + d->keys, square = 0.0;
    for (int64_t look = 0; look < 3; look++) {
        const int64_t r = look * (d->queries - 1) / 2;
        const float *q = d->q + r * width + column, *dy = g->attention_grad.dy + r * width + column;
        double sum = 0.0, mean = 0.0;
        for (int64_t j = 0; j < d->keys; j++) {
            p[j] = dp[j] = 0.0;
            for (int64_t i = 0; i < dim; i++) {
                p[j] += (double)q[i] * (double)d->k[j * width + column + i] / sqrt((double)dim);
                dp[j] += (double)dy[i] * (double)d->v[j * width + column + i];
            }
            sum += p[j] = exp(p[j]);
            mean += p[j] * dp[j];
        }
        for (int64_t i = 0; i < dim; i++) {
            double value = 0.0;
            for (int64_t j = 0; j < d->keys; j++)
                value += p[j] / sum * (dp[j] - mean / sum) * (double)d->k[j * width + column + i] / sqrt((double)dim);
            bench_add_error(row, (double)g->attention_grad.dq[r * width + column + i], value, &square);
        }
    }
    gsf_free(ctx, p);
    return square;
}

// Gradients of some weights in double; x (rows, in) and dy (rows, out) of a linear layer, or of the centre of a kernel.
// The weights' gradients add up over the runs, so they are zeroed and computed once more.
static double bench_weight_grad_error(gsf_context* ctx, bench_gradient* g, int64_t rows, int64_t taps, const float* x,
                                      const float* dy, float* dweight, bench_row* row) {
    const int64_t out = g->weight.shape[0], in = g->weight.shape[1];
    double square = 0.0;
    memset(dweight, 0, (size_t)g->weight.count * sizeof(float));
    bench_run_gradient(ctx, g);
    for (int64_t o = 0; o < out; o += out / 5)
        for (int64_t i = 0; i < in; i += in / 5) {
            double value = 0.0;
            for (int64_t r = 0; r < rows; r++) value += (double)x[r * in + i] * (double)dy[r * out + o];
            bench_add_error(row, (double)dweight[(o * in + i) * taps + taps / 2], value, &square);
        }
    return square;
}

// height 0: a linear layer of `width` rows, or with `heads` attention of so many tokens
static void bench_one_gradient(const bench_options* o, gsf_cpu_level level, int threads, int32_t heads, int64_t height,
                               int64_t width, int64_t in, int64_t out) {
    char name[96];
    gsf_context ctx;
    bench_gradient g;
    if (height) snprintf(name, sizeof name, "conv gradients f32 3x3 %lldx%lld C=%lld N=%lld", (long long)width,
                         (long long)height, (long long)in, (long long)out);
    else if (heads) snprintf(name, sizeof name, "attention gradients f32 H=%d D=64 S=%lld", (int)heads, (long long)width);
    else snprintf(name, sizeof name, "linear gradients f32 M=%lld N=%lld K=%lld", (long long)width, (long long)out,
                  (long long)in);
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, level, threads)) return;
    const int64_t rows = (height ? height : 1) * width, taps = height ? 9 : 1;
    const int64_t shape[4] = {out, in, 3, 3}, all = heads ? 8 * rows * in : 2 * (rows * (in + out) + taps * in * out);
    float* memory = (float*)bench_alloc(&ctx, (size_t)all + (size_t)heads * (size_t)width, sizeof(float));
    bench_fill(memory, (size_t)all * sizeof(float), GSF_NN_F32, 6);
    memset(&g, 0, sizeof g);
    float *x = memory, *dy = x + rows * in, *dx = dy + rows * out, *dweight = dx + rows * in;
    double flops = 4.0 * (double)rows * (double)taps * (double)in * (double)out;
    g.weight = gsf_nn_wrap_tensor("weight", dweight + taps * in * out, height ? 4 : 2, shape);
    if (heads) {
        float* part = memory; // q, k, v, out, dy, dq, dk, dv
        gsf__nn_attention_desc* a = &g.attention;
        const gsf__nn_attention_grad_desc grad = {a, part + 4 * rows * in, part + 5 * rows * in, part + 6 * rows * in,
                                                  part + 7 * rows * in};
        a->queries = a->keys = width;
        a->heads = heads;
        a->head_dim = 64;
        a->q = part;
        a->k = part + rows * in;
        a->v = part + 2 * rows * in;
        a->out = part + 3 * rows * in;
        a->lse = memory + all;
        g.attention_grad = grad;
        flops = 10.0 * (double)width * (double)width * (double)in;
        bench_require(&ctx, gsf__nn_run_attention(&ctx, NULL, a));
    } else if (height) {
        g.conv.x = x;
        g.conv.frames = 1;
        g.conv.height = height;
        g.conv.width = width;
        g.conv.weight = &g.weight;
        g.conv_grad.forward = &g.conv;
        g.conv_grad.dy = dy;
        g.conv_grad.dx = dx;
        g.conv_grad.dweight = dweight;
    } else {
        g.linear.x = x;
        g.linear.rows = rows;
        g.linear.weight = &g.weight;
        g.linear.dy = dy;
        g.linear.dx = dx;
        g.linear.dweight = dweight;
    }
    bench_row row = bench_make_row(name, level, threads, 0.0, 0.0, flops, "flop");
    row.flops = flops;
    bench_time(o, &ctx, &row, bench_run_gradient, &g, 1.0);
    row.error_max = row.error_rel_l2 = 0.0;
    const double square = heads ? bench_attention_grad_error(&ctx, &g, &row)
                                : bench_weight_grad_error(&ctx, &g, rows, taps, x, dy, dweight, &row);
    row.error_rel_l2 = sqrt(row.error_rel_l2 / square);
    row.reference = "float64";
    bench_print(o->json, &row);
    gsf_free(&ctx, memory);
}

static void bench_gradients(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        BENCH_EACH(level) bench_one_gradient(o, level, threads, 0, 0, 64, 256, 256);
        bench_one_gradient(o, o->level, threads, 48, 0, 1056, 3072, 3072);
        bench_one_gradient(o, o->level, threads, 0, 0, 1056, 3072, 3072);
        bench_one_gradient(o, o->level, threads, 0, 240, 360, 24, 24);
        bench_one_gradient(o, o->level, threads, 0, 60, 90, 48, 48);
    }
}

// ---- a whole transformer block ------------------------------------------------------

typedef struct bench_block {
    gsf_nn_transformer net;
    gsf__dit_nets nets;
    gsf__dit_block block;
    gsf_nn_transformer_desc in;
    gsf__dit_run run;
    bench_weights weights;
    float* first; // the residual stream before the block
} bench_block;

enum { BENCH_BLOCK_TEXT = 226 };

// The release's sizes; `tokens` includes the text tokens.
static void bench_block_sizes(bench_block* b, int64_t tokens, int64_t references) {
    b->net.heads = 48;
    b->net.head_dim = 64;
    b->net.layers = 1;
    b->net.in_channels = 32;
    b->net.out_channels = 16;
    b->net.text_tokens = BENCH_BLOCK_TEXT;
    b->net.text_channels = 4096;
    b->net.time_channels = 512;
    b->net.patch = b->net.temporal_ratio = 1;
    b->net.attention_bias = b->net.rotary_positions = 1;
    b->net.norm_eps = 1e-5;
    b->in.batch = b->in.reference_batch = b->in.frames = b->in.height = 1;
    b->in.width = (int32_t)(tokens - BENCH_BLOCK_TEXT);
    b->in.reference_tokens = references;
}

static void bench_run_block(gsf_context* ctx, void* arg) {
    bench_block* b = (bench_block*)arg;
    memcpy(b->run.x, b->first, (size_t)(b->run.tokens * b->run.width) * sizeof(float));
    bench_require(ctx, gsf__dit_block_forward(&b->run, 0));
}

// `references`: tokens of the cross-attention; 0: no cross-attention, as in diffusers' CogVideoXBlock.
static void bench_one_block(const bench_options* o, int threads, gsf_nn_dtype dtype, int bf16, int64_t tokens,
                            int64_t references) {
    char name[96];
    snprintf(name, sizeof name, "block %s S=%lld R=%lld", dtype == GSF_NN_F32 ? "f32" : "bf16", (long long)tokens,
             (long long)references);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    bench_block b;
    memset(&b, 0, sizeof b);
    bench_block_sizes(&b, tokens, references);
    b.in.references = references ? (float*)bench_alloc(&ctx, (size_t)references * 3072, sizeof(float)) : NULL;
    if (references) bench_fill((void*)(uintptr_t)b.in.references, (size_t)references * 3072 * sizeof(float), GSF_NN_F32, 5);
    const gsf__nn_sizes sizes = gsf__dit_tensor_sizes(&b.net);
    char* weights = bench_make_weights(&ctx, &b.weights, dtype, &sizes, gsf__dit_block_entries, &b.block);
    b.nets.blocks = &b.block;
    b.net.nets = &b.nets;
    b.net.bf16 = bf16;
    gsf__dit_begin_run(&b.run, &ctx, &b.net);
    gsf__dit_set_input(&b.run, &b.in);
    const size_t floats = gsf__dit_lay_out(&b.run, NULL), stream = (size_t)(b.run.tokens * b.run.width);
    float* memory = (float*)bench_alloc(&ctx, floats + stream, sizeof(float));
    gsf__dit_lay_out(&b.run, memory);
    b.first = memory + floats;
    bench_fill(memory, (floats + stream) * sizeof(float), GSF_NN_F32, 6); // includes the rotation table
    double bytes, flops;
    gsf__nn_query_transformer(&b.net, &b.in, &bytes, &flops);
    // first and last layer
    flops -= 2.0 * (double)b.run.video * (32 + 16) * 3072 + 2.0 * BENCH_BLOCK_TEXT * 4096 * 3072;
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, flops, "flop");
    row.flops = flops;
    if (bf16) row.variant = BENCH_BF16;
    bench_time(o, &ctx, &row, bench_run_block, &b, 1.0);
    bench_print(o->json, &row);
    gsf__nn_destroy_workspace(&ctx, &b.run.nn.workspace);
    gsf_free(&ctx, memory);
    gsf_free(&ctx, weights);
    gsf_free(&ctx, (void*)(uintptr_t)b.in.references);
}

static void bench_blocks(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        if (o->quick) {
            bench_one_block(o, threads, GSF_NN_F32, 0, 512, 0);
            continue;
        }
        bench_one_block(o, threads, GSF_NN_F32, 0, 4096, 0);
        for (int bf16 = 0; bf16 <= bench_has_bf16(o, GSF_NN_BF16); bf16++) {
            bench_one_block(o, threads, GSF_NN_BF16, bf16, 4096, 0);
            bench_one_block(o, threads, GSF_NN_BF16, bf16, 4096, 1850);
        }
    }
}

// ---- image encoders -------------------------------------------------------------------

// Times `fn`, which writes `out` or adds to `first` there; with products of bfloat16, also the error that they make, relative
// to what it writes or adds.
static void bench_time_low(const bench_options* o, gsf_context* ctx, bench_row* row, void (*fn)(gsf_context*, void*), void* arg,
                           int32_t* bf16, int32_t low, const float* first, const float* out, size_t count) {
    float* exact = NULL;
    if (low) {
        exact = (float*)bench_alloc(ctx, count, sizeof(float));
        *bf16 = 0;
        fn(ctx, arg);
        memcpy(exact, out, count * sizeof(float));
        row->variant = BENCH_BF16;
    }
    *bf16 = low;
    bench_time(o, ctx, row, fn, arg, 1.0);
    if (low) {
        double square = 0.0;
        row->error_max = row->error_rel_l2 = 0.0;
        for (size_t i = 0; i < count; i++) {
            const double before = first ? (double)first[i] : 0.0;
            bench_add_error(row, (double)out[i] - before, (double)exact[i] - before, &square);
        }
        row->error_rel_l2 = sqrt(row->error_rel_l2 / square);
        row->reference = "float32";
    }
    bench_print(o->json, row);
    gsf_free(ctx, exact);
}

// patches of 350 x 518
enum { BENCH_VIT_WIDTH = 1024, BENCH_VIT_HEADS = 16, BENCH_VIT_ROWS = 25, BENCH_VIT_ACROSS = 37 };

typedef struct bench_vit {
    gsf_nn_dinov2 net;
    gsf__vit vit;
    gsf__nn_block blocks[24]; // all layers share the weights of one block, which exceed every cache
    bench_weights block_weights, weights;
    gsf_nn_encoder_desc in;
    gsf__nn_run run;
    float *first, *x, *out;    // residual stream before a block; working copy; the encoder's output
} bench_vit;

static void bench_vit_sizes(bench_vit* b, int64_t layers) {
    gsf__vit* v = &b->vit;
    v->sizes.width = BENCH_VIT_WIDTH;
    v->sizes.mlp = 4 * BENCH_VIT_WIDTH;
    v->sizes.heads = BENCH_VIT_HEADS;
    v->sizes.head_dim = BENCH_VIT_WIDTH / BENCH_VIT_HEADS;
    v->sizes.eps = v->sizes.head_eps = 1e-6f;
    v->sizes.activation = GSF__NN_GELU;
    v->sizes.qkv_bias = v->sizes.head_norm = 1;
    v->channels = 3;
    v->patch = 14;
    v->registers = 4;
    v->grid = 37;
    v->layers = layers;
    v->block_names = v->prefix = "none";
    v->blocks = b->blocks;
    b->net.nets = v;
    b->in.images = 1;
    b->in.height = BENCH_VIT_ROWS * 14;
    b->in.width = BENCH_VIT_ACROSS * 14;
}

static void bench_run_dinov2(gsf_context* ctx, void* arg) {
    bench_vit* b = (bench_vit*)arg;
    bench_require(ctx, gsf_nn_encode_dinov2(ctx, &b->net, &b->in, b->out));
}

// Complete DINOv2-L with registers, from pixels to the last norm.
static void bench_one_dinov2(const bench_options* o, int threads, int32_t bf16, int64_t layers) {
    char name[96];
    snprintf(name, sizeof name, "dinov2 f32 %dx%d L=%d", BENCH_VIT_ROWS * 14, BENCH_VIT_ACROSS * 14, (int)layers);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    bench_vit* b = (bench_vit*)gsf_alloc_zeroed(&ctx, 1, sizeof *b);
    bench_vit_sizes(b, layers);
    const gsf__nn_sizes block_sizes = gsf__nn_sizes_of_block(&b->vit.sizes), sizes = gsf__vit_sizes(&b->vit);
    char* block = bench_make_weights(&ctx, &b->block_weights, GSF_NN_F32, &block_sizes, gsf__dinov2_block_entries, b->blocks);
    char* weights = bench_make_weights(&ctx, &b->weights, GSF_NN_F32, &sizes, gsf__dinov2_entries, &b->vit);
    for (int64_t i = 1; i < layers; i++) b->blocks[i] = b->blocks[0];
    const size_t pixels = 3 * (size_t)b->in.height * (size_t)b->in.width;
    float* memory = (float*)bench_alloc(&ctx, pixels + BENCH_VIT_ROWS * BENCH_VIT_ACROSS * BENCH_VIT_WIDTH, sizeof(float));
    bench_fill(memory, pixels * sizeof(float), GSF_NN_F32, 6);
    b->in.pixels = memory;
    b->out = memory + pixels;
    double flops;
    gsf__nn_query_dinov2(&b->net, &b->in, NULL, &flops);
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, flops, "flop");
    row.flops = flops;
    bench_time_low(o, &ctx, &row, bench_run_dinov2, b, &b->net.bf16, bf16, NULL, b->out,
                   BENCH_VIT_ROWS * BENCH_VIT_ACROSS * BENCH_VIT_WIDTH);
    gsf_free(&ctx, memory);
    gsf_free(&ctx, block);
    gsf_free(&ctx, weights);
    gsf_free(&ctx, b);
}

static void bench_run_pair(gsf_context* ctx, void* arg) {
    bench_vit* b = (bench_vit*)arg;
    const int64_t images = b->in.images, tokens = b->run.image_tokens;
    memcpy(b->x, b->first, (size_t)(images * tokens * BENCH_VIT_WIDTH) * sizeof(float));
    bench_require(ctx, gsf__nn_block_forward(&b->run, &b->blocks[0], 0, b->x, images, tokens));
    bench_require(ctx, gsf__nn_block_forward(&b->run, &b->blocks[0], 0, b->x, 1, images * tokens));
}

// One frame block and one global block of VGGT.
static void bench_one_pair(const bench_options* o, int threads, int32_t bf16, int32_t images) {
    char name[96];
    snprintf(name, sizeof name, "vggt pair f32 %dx%d N=%d", BENCH_VIT_ROWS * 14, BENCH_VIT_ACROSS * 14, (int)images);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    bench_vit* b = (bench_vit*)gsf_alloc_zeroed(&ctx, 1, sizeof *b);
    bench_vit_sizes(b, 1);
    const gsf__nn_sizes sizes = gsf__nn_sizes_of_block(&b->vit.sizes);
    char* weights = bench_make_weights(&ctx, &b->weights, GSF_NN_F32, &sizes, gsf__vggt_block_entries, b->blocks);
    gsf__nn_run* run = &b->run;
    const int64_t quarter = b->vit.sizes.head_dim / 4;
    b->in.images = images;
    run->ctx = &ctx;
    run->sizes = &b->vit.sizes;
    run->special = 5;
    run->across = BENCH_VIT_ACROSS;
    run->image_tokens = 5 + BENCH_VIT_ROWS * BENCH_VIT_ACROSS;
    const int64_t rows = images * run->image_tokens;
    const size_t values = (size_t)(rows * BENCH_VIT_WIDTH), rotation = (size_t)(BENCH_VIT_ACROSS * quarter);
    run->vectors_size = 2 * BENCH_VIT_WIDTH;
    run->wide_count = (int64_t)gsf__nn_wide(run->sizes, rows, GSF__VIT_MLP_ROWS);
    float* memory = (float*)bench_alloc(&ctx, 3 * values + (size_t)run->wide_count + run->vectors_size + 2 * rotation,
                                        sizeof(float));
    b->first = memory;
    b->x = memory + values;
    run->normed = b->x + values;
    run->wide = run->normed + values;
    run->vectors = run->wide + run->wide_count;
    float* table = run->vectors + run->vectors_size;
    run->cos = table;
    run->sin = table + rotation;
    bench_fill(memory, values * sizeof(float), GSF_NN_F32, 6);
    gsf__vggt_make_rotation(100.0, BENCH_VIT_ACROSS, quarter, table, table + rotation);
    const double flops = gsf__nn_block_flops(run->sizes, images, (double)run->image_tokens) +
                         gsf__nn_block_flops(run->sizes, 1.0, (double)rows);
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, flops, "flop");
    row.flops = flops;
    bench_time_low(o, &ctx, &row, bench_run_pair, b, &run->bf16, bf16 ? GSF__NN_BF16_ALL : 0, b->first, b->x, values);
    gsf__nn_destroy_workspace(&ctx, &run->workspace);
    gsf_free(&ctx, memory);
    gsf_free(&ctx, weights);
    gsf_free(&ctx, b);
}

static void bench_encoders(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        for (int bf16 = 0; bf16 <= bench_has_bf16(o, GSF_NN_BF16); bf16++) {
            bench_one_dinov2(o, threads, bf16, 2);
            if (!o->quick && threads == 2) bench_one_dinov2(o, threads, bf16, 24); // half a minute
            bench_one_pair(o, threads, bf16, 2);
        }
    }
}

// ---- a whole model from its folder ---------------------------------------------------

typedef struct bench_memory { // resident bytes of this process, sampled by a separate thread
    pthread_t thread;
    atomic_int stop;
    double anonymous, file; // peaks
} bench_memory;

static void* bench_watch(void* arg) {
    bench_memory* m = (bench_memory*)arg;
    while (!atomic_load(&m->stop)) {
        char line[128];
        double kib;
        FILE* f = fopen("/proc/self/status", "r");
        while (f && fgets(line, sizeof line, f)) {
            if (sscanf(line, "RssAnon: %lf", &kib) == 1 && kib * 1024.0 > m->anonymous) m->anonymous = kib * 1024.0;
            if (sscanf(line, "RssFile: %lf", &kib) == 1 && kib * 1024.0 > m->file) m->file = kib * 1024.0;
        }
        if (f) fclose(f);
        const struct timespec wait = {0, 50000000};
        nanosleep(&wait, NULL);
    }
    return NULL;
}

typedef struct bench_steps { // time of every reported step
    double* seconds;
    size_t count, limit;
} bench_steps;

static void bench_step(void* user, const char* stage, double done, double total) {
    bench_steps* s = (bench_steps*)user;
    if (s->count < s->limit) s->seconds[s->count++] = bench_now();
    fprintf(stderr, "%s %.0f of %.0f\n", stage, done, total);
}

typedef struct bench_model {
    const char* folder;
    gsf_nn_transformer transformer;
    gsf_nn_transformer_desc in;
    gsf_nn_vae vae;
    int64_t frames, height, width; // of the latents
    float *x, *y;
} bench_model;

static void bench_run_forward(gsf_context* ctx, void* arg) {
    bench_model* m = (bench_model*)arg;
    bench_require(ctx, gsf_nn_run_transformer(ctx, &m->transformer, &m->in, m->y));
}

static void bench_run_decode(gsf_context* ctx, void* arg) {
    bench_model* m = (bench_model*)arg;
    bench_require(ctx, gsf_nn_decode_vae(ctx, &m->vae, NULL, m->x, m->frames, m->height, m->width, m->y));
}

static void bench_run_encode(gsf_context* ctx, void* arg) {
    bench_model* m = (bench_model*)arg;
    bench_require(ctx, gsf_nn_encode_vae(ctx, &m->vae, NULL, m->x, m->frames, m->height, m->width, m->y, NULL));
}

// Runs once, since it takes minutes. Memory is that of the whole process, including inputs and outputs.
static void bench_once(const bench_options* o, gsf_context* ctx, const char* name, const char* variant, bench_model* m,
                       bench_body body, double flops, double bytes) {
    double times[256]; // further steps are ignored
    bench_steps steps = {times, 0, 256};
    bench_memory memory;
    memset(&memory, 0, sizeof memory);
    ctx->progress.progress_fn = bench_step;
    ctx->progress.user = &steps;
    if (pthread_create(&memory.thread, NULL, bench_watch, &memory) != 0) bench_require(ctx, GSF_ERROR_OUT_OF_MEMORY);
    bench_row row = bench_make_row(name, ctx->cpu_level, ctx->threads, 0.0, 0.0, flops, "flop");
    const double wall = bench_now(), cpu = bench_cpu();
    body(ctx, m);
    row.seconds = bench_now() - wall;
    row.cpu_seconds = bench_cpu() - cpu;
    row.flops = flops;
    atomic_store(&memory.stop, 1);
    pthread_join(memory.thread, NULL);
    row.peak_rss = memory.anonymous;
    row.variant = variant;
    bench_print(o->json, &row);
    for (size_t i = steps.count; i-- > 1;) times[i] -= times[i - 1];
    fprintf(stderr, "%s: %.2f GiB anonymous (%.2f announced), %.2f GiB of files; median of %d steps %.2f s\n", name,
            memory.anonymous / (1 << 30), bytes / (1 << 30), memory.file / (1 << 30), (int)steps.count,
            steps.count > 1 ? bench_median(times + 1, steps.count - 1) : 0.0);
    ctx->progress.progress_fn = NULL;
}

static void bench_fill_floats(gsf_context* ctx, float** to, size_t count, uint64_t seed) {
    *to = (float*)bench_alloc(ctx, count, sizeof(float));
    bench_fill(*to, count * sizeof(float), GSF_NN_F32, seed);
}

// One forward pass of one sample at the configured size, with the reference tokens of two photos.
static void bench_forward(const bench_options* o, gsf_context* ctx, bench_model* m) {
    char path[1024];
    snprintf(path, sizeof path, "%s/transformer", m->folder);
    gsf_nn_transformer* t = &m->transformer;
    bench_require(ctx, gsf_nn_load_transformer(ctx, path, t));
    const int32_t frames = (t->sample_frames - 1) / t->temporal_ratio + 1;
    const size_t pixels = (size_t)frames * (size_t)t->sample_height * (size_t)t->sample_width;
    const double timestep = 500.0;
    float *hidden, *text, *dino, *vggt, *references, *kv;
    memset(&m->in, 0, sizeof m->in);
    m->in.reference_tokens = 1850;
    m->in.batch = m->in.reference_batch = 1;
    m->in.frames = frames;
    m->in.height = t->sample_height;
    m->in.width = t->sample_width;
    m->in.timesteps = &timestep;
    const size_t tokens = (size_t)m->in.reference_tokens;
    bench_fill_floats(ctx, &hidden, pixels * (size_t)t->in_channels, 1);
    bench_fill_floats(ctx, &text, (size_t)t->text_tokens * (size_t)t->text_channels, 2);
    bench_fill_floats(ctx, &dino, tokens * (size_t)t->dino_channels, 3);
    bench_fill_floats(ctx, &vggt, tokens * (size_t)t->vggt_channels, 4);
    bench_fill_floats(ctx, &references, tokens * (size_t)(t->heads * t->head_dim), 5);
    bench_fill_floats(ctx, &m->y, pixels * (size_t)t->out_channels, 6);
    kv = (float*)bench_alloc(ctx, gsf__nn_query_reference_kv(t, m->in.reference_tokens, 1), sizeof(float));
    bench_require(ctx, gsf_nn_project_references(ctx, t, m->in.reference_tokens, dino, vggt, references));
    m->in.hidden = hidden;
    m->in.text = text;
    m->in.references = references;
    m->in.reference_kv = kv;
    double bytes, flops;
    gsf__nn_query_transformer(t, &m->in, &bytes, &flops);
    // The caller's buffer, filled here.
    bytes += (double)gsf__nn_query_reference_kv(t, m->in.reference_tokens, 1) * sizeof(float);
    bench_once(o, ctx, "model: transformer forward", "default", m, bench_run_forward, flops, bytes);
    m->transformer.bf16 = 1;
    m->in.reference_kv_ready = 0;
    if (bench_has_bf16(o, GSF_NN_BF16)) // with weights of another dtype, only attention uses bf16
        bench_once(o, ctx, "model: transformer forward", BENCH_BF16, m, bench_run_forward, flops, bytes);
    float* all[] = {hidden, text, dino, vggt, references, m->y, kv};
    for (size_t i = 0; i < GSF__COUNT(all); i++) gsf_free(ctx, all[i]);
    gsf_nn_destroy_transformer(ctx, t);
}

static void bench_vae(const bench_options* o, gsf_context* ctx, bench_model* m, gsf_nn_vae_way way) {
    char path[1024];
    snprintf(path, sizeof path, "%s/vae", m->folder);
    gsf_nn_vae* v = &m->vae;
    bench_require(ctx, gsf_nn_load_vae(ctx, path, v));
    const int encode = way == GSF_NN_VAE_ENCODE;
    const int64_t frames = 49; // of the paper's clips
    m->frames = encode ? frames : (frames - 1) / v->temporal_ratio + 1;
    m->height = v->sample_height / (encode ? 1 : v->spatial_ratio);
    m->width = v->sample_width / (encode ? 1 : v->spatial_ratio);
    gsf_nn_vae_info info;
    bench_require(ctx, gsf_nn_query_vae(ctx, v, way, NULL, m->frames, m->height, m->width, &info));
    const int64_t in = encode ? v->in_channels : v->latent_channels, out = encode ? v->latent_channels : v->out_channels;
    bench_fill_floats(ctx, &m->x, (size_t)(in * m->frames * m->height * m->width), 1);
    m->y = (float*)bench_alloc(ctx, (size_t)(out * info.frames * info.height * info.width), sizeof(float));
    bench_once(o, ctx, encode ? "model: vae encode" : "model: vae decode", "default", m,
               encode ? bench_run_encode : bench_run_decode, info.flops, info.bytes);
    gsf_free(ctx, m->x);
    gsf_free(ctx, m->y);
    gsf_nn_destroy_vae(ctx, v);
}

static void bench_whole_model(const bench_options* o) {
    gsf_context ctx;
    bench_model m;
    (void)bench_context(&ctx, o->level, o->threads ? o->threads : 2);
    memset(&m, 0, sizeof m);
    m.folder = o->model;
    if (bench_wanted(o, "model: vae decode", ctx.threads)) bench_vae(o, &ctx, &m, GSF_NN_VAE_DECODE);
    if (bench_wanted(o, "model: transformer forward", ctx.threads)) bench_forward(o, &ctx, &m);
    if (bench_wanted(o, "model: vae encode", ctx.threads)) bench_vae(o, &ctx, &m, GSF_NN_VAE_ENCODE);
}

// ---- the pipeline: run time and error of the final frames, on a small model ---------------

typedef struct bench_pipeline {
    const bench_options* options;
    gsf_context ctx;
    gsf_nn_transformer transformer;
    gsf_nn_vae vae;
    gsf_nn_schedule schedule;
    gsf_nn_sample_desc desc;   // as in the GSFixer release: 50 steps of DDIM, guidance 6
    char dtype[8];             // dtype of the weights
    float* out;
    size_t count;
} bench_pipeline;

static void bench_open_pipeline(bench_pipeline* p, const char* folder) {
    gsf_context* ctx = &p->ctx;
    char path[1024];
    memset(p, 0, sizeof *p);
    (void)bench_context(ctx, GSF_CPU_AUTO, 2);
    snprintf(path, sizeof path, "%s/transformer", folder);
    bench_require(ctx, gsf_nn_load_transformer(ctx, path, &p->transformer));
    snprintf(path, sizeof path, "%s/vae", folder);
    bench_require(ctx, gsf_nn_load_vae(ctx, path, &p->vae));
    snprintf(path, sizeof path, "%s/scheduler/scheduler_config.json", folder);
    bench_require(ctx, gsf_nn_load_schedule(ctx, path, &p->schedule));
    const gsf_nn_transformer* t = &p->transformer;
    snprintf(p->dtype, sizeof p->dtype, "%s", gsf__nn_dtype_name(t->weights.tensors[0].dtype));
    gsf_nn_sample_desc* d = &p->desc;
    d->frames = 9;
    d->any_frames = 1;
    d->height = t->sample_height * p->vae.spatial_ratio;
    d->width = t->sample_width * p->vae.spatial_ratio;
    d->reference_tokens = 2 * t->sample_height / 2 * t->sample_width / 2; // two photos
    const size_t tokens = (size_t)d->reference_tokens;
    float *control, *text, *dino, *vggt, *references;
    p->count = 3 * (size_t)d->frames * (size_t)d->height * (size_t)d->width;
    bench_fill_floats(ctx, &control, p->count, 1);
    bench_fill_floats(ctx, &text, 2 * (size_t)t->text_tokens * (size_t)t->text_channels, 2);
    bench_fill_floats(ctx, &dino, tokens * (size_t)t->dino_channels, 3);
    bench_fill_floats(ctx, &vggt, tokens * (size_t)t->vggt_channels, 4);
    bench_fill_floats(ctx, &references, tokens * (size_t)(t->heads * t->head_dim), 5);
    bench_require(ctx, gsf_nn_project_references(ctx, t, d->reference_tokens, dino, vggt, references));
    const size_t row = (size_t)d->width, area = row * (size_t)d->height;
    for (size_t i = 0; i < p->count; i++) // a soft pattern that moves sideways
        control[i] = 0.8f * sinf(0.05f * (float)(i % row) + 0.1f * (float)(i / area)) * cosf(0.07f * (float)(i % area / row));
    gsf_free(ctx, dino);
    gsf_free(ctx, vggt);
    d->control = control;
    d->text = text;
    d->references = references;
    p->out = (float*)bench_alloc(ctx, p->count, sizeof(float));
}

static void bench_close_pipeline(bench_pipeline* p) {
    gsf_context* ctx = &p->ctx;
    gsf_free(ctx, (void*)(uintptr_t)p->desc.control);
    gsf_free(ctx, (void*)(uintptr_t)p->desc.text);
    gsf_free(ctx, (void*)(uintptr_t)p->desc.references);
    gsf_free(ctx, p->out);
    gsf_nn_destroy_schedule(ctx, &p->schedule);
    gsf_nn_destroy_vae(ctx, &p->vae);
    gsf_nn_destroy_transformer(ctx, &p->transformer);
}

// Runs once, since repetitions would take minutes. Error of the frames relative to `reference`, if any.
static void bench_restore(bench_pipeline* p, const gsf_nn_sample_desc* desc, const char* series, const char* variant,
                          const float* expected, const char* reference) {
    char name[96];
    snprintf(name, sizeof name, "pipeline: %s %dx%dx%d", series, (int)desc->frames, (int)desc->height, (int)desc->width);
    if (!bench_wanted(p->options, name, p->ctx.threads)) return;
    gsf_nn_sample_stats stats;
    bench_row row = bench_make_row(name, p->ctx.cpu_level, p->ctx.threads, 0.0, 0.0, (double)desc->frames, "frames");
    const double wall = bench_now(), cpu = bench_cpu();
    bench_require(&p->ctx, gsf_nn_sample(&p->ctx, &p->transformer, &p->vae, &p->schedule, desc, p->out, &stats));
    row.seconds = bench_now() - wall;
    row.cpu_seconds = bench_cpu() - cpu;
    row.variant = variant;
    if (expected) {
        double worst = 0.0, difference = 0.0, square = 0.0;
        for (size_t i = 0; i < p->count; i++) {
            const double error = fabs((double)p->out[i] - (double)expected[i]);
            if (!(error <= worst)) worst = error;
            difference += error * error;
            square += (double)expected[i] * (double)expected[i];
        }
        row.error_max = worst;
        row.error_rel_l2 = sqrt(difference / square);
        row.reference = reference;
    }
    bench_print(p->options->json, &row);
}

static float* bench_keep(bench_pipeline* p) { // a copy of the frames of the last run
    float* kept = (float*)bench_alloc(&p->ctx, p->count, sizeof(float));
    memcpy(kept, p->out, p->count * sizeof(float));
    return kept;
}

// Fewer steps and other solvers, relative to the converged path that all of them approximate.
static void bench_solvers(bench_pipeline* p, const float* converged) {
    static const char* const names[] = {"ddim", "dpmpp", "unipc"};
    static const int32_t steps[] = {5, 8, 12, 20, 50};
    for (int solver = 0; solver < 3; solver++)
        for (size_t i = 0; i < GSF__COUNT(steps); i++) {
            char variant[32];
            gsf_nn_sample_desc d = p->desc;
            d.solver = (gsf_nn_solver)solver;
            d.steps = p->options->quick ? 2 + (int32_t)i : steps[i];
            snprintf(variant, sizeof variant, "%s %d", names[solver], (int)d.steps);
            bench_restore(p, &d, "steps", variant, converged, "unipc, 150 steps");
        }
}

// Options that skip work within a step, relative to the same steps without them.
static void bench_skips(bench_pipeline* p, const float* expected) {
    static const struct {
        const char* name;
        float guidance, guidance_end, strength, cache;
        int no_kv;
    } skips[] = {
        {"no reference cache", 0.0f, 0.0f, 0.0f, 0.0f, 1},    {"guidance until 80 %", 0.0f, 0.8f, 0.0f, 0.0f, 0},
        {"guidance until 60 %", 0.0f, 0.6f, 0.0f, 0.0f, 0},   {"guidance until 40 %", 0.0f, 0.4f, 0.0f, 0.0f, 0},
        {"no guidance", 1.0f, 0.0f, 0.0f, 0.0f, 0},           {"strength 0.9", 0.0f, 0.0f, 0.9f, 0.0f, 0},
        {"strength 0.7", 0.0f, 0.0f, 0.7f, 0.0f, 0},          {"strength 0.5", 0.0f, 0.0f, 0.5f, 0.0f, 0},
        {"block cache 0.1", 0.0f, 0.0f, 0.0f, 0.1f, 0},       {"block cache 0.2", 0.0f, 0.0f, 0.0f, 0.2f, 0},
        {"block cache 0.4", 0.0f, 0.0f, 0.0f, 0.4f, 0},       {"block cache 0.8", 0.0f, 0.0f, 0.0f, 0.8f, 0},
    };
    for (size_t i = 0; i < GSF__COUNT(skips); i++) {
        gsf_nn_sample_desc d = p->desc;
        d.guidance = skips[i].guidance;
        d.guidance_end = skips[i].guidance_end;
        d.strength = skips[i].strength;
        d.block_cache = skips[i].cache;
        d.no_reference_cache = skips[i].no_kv;
        bench_restore(p, &d, "skips", skips[i].name, expected, "all of it");
    }
}

// The first model's frames are the reference for the others, which have the same weights in other dtypes.
static void bench_pipelines(const bench_options* o) {
    bench_pipeline p;
    float *converged, *expected = NULL;
    for (int i = 0; i < o->pipeline_count; i++) {
        bench_open_pipeline(&p, o->pipelines[i]);
        p.options = o;
        p.desc.steps = o->quick ? 4 : 50;
        if (i == 0) {
            gsf_nn_sample_desc d = p.desc;
            d.solver = GSF_NN_SOLVER_UNIPC;
            d.steps = o->quick ? 12 : 150;
            bench_restore(&p, &d, "steps", "unipc, converged", NULL, "none");
            converged = bench_keep(&p);
            bench_solvers(&p, converged);
            gsf_free(&p.ctx, converged);
        }
        bench_restore(&p, &p.desc, "skips", i ? p.dtype : "all of it", expected, "all of it");
        if (bench_has_bf16(o, GSF_NN_BF16)) {
            // F32 weights keep float32 products.
            const char* const names[] = {"bf16 attention", "bf16 weights and products"};
            if (i == 0) expected = bench_keep(&p);
            p.transformer.bf16 = 1;
            bench_restore(&p, &p.desc, "skips", names[i != 0], expected, "all of it");
            p.transformer.bf16 = 0;
        }
        if (i == 0) {
            if (!expected) expected = bench_keep(&p);
            bench_skips(&p, expected);
            bench_require(&p.ctx, gsf_nn_quantize_transformer(&p.ctx, &p.transformer, NULL));
            bench_restore(&p, &p.desc, "skips", "int8", expected, "all of it");
            p.transformer.bf16 = bench_has_bf16(o, GSF_NN_BF16);
            if (p.transformer.bf16) bench_restore(&p, &p.desc, "skips", "int8, bf16 attention", expected, "all of it");
        }
        if (i + 1 == o->pipeline_count) gsf_free(&p.ctx, expected);
        bench_close_pipeline(&p);
    }
}

// ---- a layer of the text encoder at T5-XXL's size ---------------------------------------

typedef struct bench_t5 {
    gsf__nn_run run;
    gsf_nn_t5 net;
    gsf__nn_block_sizes sizes;
    gsf_nn_t5_desc in;
    gsf__nn_block block;
    bench_weights weights;
    float *x, *first; // the stream that the layer changes; its initial value
} bench_t5;

static void bench_run_t5(gsf_context* ctx, void* arg) {
    bench_t5* b = (bench_t5*)arg;
    memcpy(b->x, b->first, (size_t)b->in.tokens * (size_t)b->net.width * sizeof(float));
    bench_require(ctx, gsf__nn_block_forward(&b->run, &b->block, 0, b->x, 1, b->in.tokens));
}

static void bench_one_t5(const bench_options* o, int threads, gsf_nn_dtype dtype, int32_t bf16, int32_t tokens) {
    char name[96];
    snprintf(name, sizeof name, "t5 layer %s S=%d", dtype == GSF_NN_F32 ? "f32" : "bf16", (int)tokens);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    bench_t5 b;
    memset(&b, 0, sizeof b);
    b.net.width = 4096;
    b.net.heads = b.net.head_dim = 64;
    b.net.hidden = 10240;
    b.net.layers = 1;
    b.net.buckets = 32;
    b.net.max_distance = 128;
    b.net.norm_eps = 1e-6;
    b.in.batch = 1;
    b.in.tokens = tokens;
    b.sizes = gsf__t5_block_sizes(&b.net);
    const gsf__nn_sizes sizes = gsf__nn_sizes_of_block(&b.sizes);
    char* weights = bench_make_weights(&ctx, &b.weights, dtype, &sizes, gsf__t5_block_entries, &b.block);
    float* bias;
    const size_t floats = gsf__t5_lay_out(&b.run, &b.net, &b.in, &b.x, &bias, NULL), stream = (size_t)tokens * 4096;
    float* memory = (float*)bench_alloc(&ctx, floats + stream, sizeof(float));
    bench_fill(memory, (floats + stream) * sizeof(float), GSF_NN_F32, 6); // includes the bias
    gsf__t5_lay_out(&b.run, &b.net, &b.in, &b.x, &bias, memory);
    b.run.ctx = &ctx;
    b.run.sizes = &b.sizes;
    b.run.bias = bias;
    b.run.scale = 1.0f;
    b.first = memory + floats;
    double bytes, flops;
    gsf__nn_query_t5(&b.net, &b.in, &bytes, &flops);
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, flops, "flop");
    row.flops = flops;
    bench_time_low(o, &ctx, &row, bench_run_t5, &b, &b.run.bf16, bf16 ? GSF__NN_BF16_ALL : 0, b.first, b.x, stream);
    gsf__nn_destroy_workspace(&ctx, &b.run.workspace);
    gsf_free(&ctx, memory);
    gsf_free(&ctx, weights);
}

static void bench_t5s(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        bench_one_t5(o, threads, GSF_NN_F32, 0, o->quick ? 64 : 226);
        for (int bf16 = 0; bf16 <= bench_has_bf16(o, GSF_NN_BF16); bf16++)
            bench_one_t5(o, threads, GSF_NN_BF16, bf16, o->quick ? 64 : 226);
    }
}

// ---- the captioner's language model ----------------------------------------------------

enum { BENCH_OPT_WIDTH = 2560, BENCH_OPT_HEADS = 32, BENCH_OPT_ROWS = 33, BENCH_OPT_CACHE = 64 }; // OPT-2.7b

typedef struct bench_opt {
    gsf__blip net;
    gsf__nn_block block;
    bench_weights weights;
    gsf__nn_run run;
    gsf__opt_run state;
    int64_t rows, past;
    const float* first; // residual stream before the layer
} bench_opt;

static void bench_run_opt(gsf_context* ctx, void* arg) {
    bench_opt* b = (bench_opt*)arg;
    b->state.cache.past = b->past;
    memcpy(b->state.x, b->first, (size_t)(b->rows * BENCH_OPT_WIDTH) * sizeof(float));
    bench_require(ctx, gsf__nn_block_forward(&b->run, &b->block, 0, b->state.x, 1, b->rows));
}

// One layer of OPT-2.7b: prefill of an image's query tokens and bos, or decoding of one token, which is limited by
// reading the weights.
static void bench_one_opt(const bench_options* o, int threads, int64_t rows) {
    char name[96];
    snprintf(name, sizeof name, "opt layer f16 D=%d rows=%lld", BENCH_OPT_WIDTH, (long long)rows);
    gsf_context ctx;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    bench_opt* b = (bench_opt*)gsf_alloc_zeroed(&ctx, 1, sizeof *b);
    gsf__opt* opt = &b->net.text;
    opt->sizes.width = BENCH_OPT_WIDTH;
    opt->sizes.mlp = 4 * BENCH_OPT_WIDTH;
    opt->sizes.heads = BENCH_OPT_HEADS;
    opt->sizes.head_dim = BENCH_OPT_WIDTH / BENCH_OPT_HEADS;
    opt->sizes.eps = 1e-5f;
    opt->sizes.activation = GSF__NN_RELU;
    opt->layers = opt->vocabulary = 1;
    opt->blocks = &b->block;
    opt->sizes.qkv_bias = 1;
    const gsf__nn_sizes sizes = gsf__nn_sizes_of_block(&opt->sizes);
    char* weights = bench_make_weights(&ctx, &b->weights, GSF_NN_F16, &sizes, gsf__opt_block_entries, &b->block);
    const size_t bytes = b->weights.used, stream = (size_t)rows * BENCH_OPT_WIDTH;
    b->state.cache.capacity = BENCH_OPT_CACHE;
    const size_t floats = gsf__opt_lay_out(&b->run, opt, rows, 1, &b->state, NULL);
    float* memory = (float*)bench_alloc(&ctx, floats + stream, sizeof(float));
    bench_fill(memory, (floats + stream) * sizeof(float), GSF_NN_F32, 6);
    gsf__opt_lay_out(&b->run, opt, rows, 1, &b->state, memory);
    b->rows = rows;
    b->past = rows > 1 ? 0 : BENCH_OPT_ROWS;
    b->first = memory + floats;
    b->run.ctx = &ctx;
    b->run.cache = &b->state.cache;
    for (int64_t i = 0; i < BENCH_OPT_HEADS * rows * rows; i++) b->state.cache.mask[i] = i % rows <= i / rows % rows;
    const double d = BENCH_OPT_WIDTH, n = (double)rows;
    const double flops = 24.0 * n * d * d + 4.0 * n * (n + (double)b->past) * d;
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, rows > 1 ? flops : (double)bytes,
                                   rows > 1 ? "flop" : "B");
    if (rows > 1) row.flops = flops;
    else row.bytes = (double)bytes;
    bench_time(o, &ctx, &row, bench_run_opt, b, 1.0);
    bench_print(o->json, &row);
    gsf__nn_destroy_workspace(&ctx, &b->run.workspace);
    gsf_free(&ctx, memory);
    gsf_free(&ctx, weights);
    gsf_free(&ctx, b);
}

static void bench_captions(const bench_options* o) {
    for (int threads = 1; threads <= 2; threads++) {
        bench_one_opt(o, threads, 1);
        bench_one_opt(o, threads, BENCH_OPT_ROWS);
    }
}

// ---- a frame of the restorer mini ---------------------------------------------------

typedef struct bench_mini {
    gsf__mini net;
    gsf__mini_run run;
    gsf__mini_input in;
} bench_mini;

static void bench_run_mini(gsf_context* ctx, void* arg) {
    bench_mini* b = (bench_mini*)arg;
    bench_require(ctx, gsf__mini_forward(&b->run, &b->in));
}

static void bench_one_mini(const bench_options* o, int threads) {
    enum { WIDTH = 720, HEIGHT = 480, REFERENCES = 3 };
    const char* name = "mini 720x480, 3 references";
    const size_t pixels = (size_t)WIDTH * HEIGHT, frame = pixels * GSF__MINI_FRAME;
    const size_t all = frame + REFERENCES * pixels * GSF__MINI_REFERENCE;
    gsf_context ctx;
    bench_mini b;
    if (!bench_wanted(o, name, threads) || !bench_context(&ctx, o->level, threads)) return;
    memset(&b, 0, sizeof b);
    float* planes = (float*)bench_alloc(&ctx, all, sizeof(float));
    bench_fill(planes, all * sizeof(float), GSF_NN_F32, 7);
    for (size_t i = 0; i < all; i++) planes[i] = fabsf(planes[i]); // all references show something everywhere
    b.in.width = WIDTH;
    b.in.height = HEIGHT;
    b.in.references = REFERENCES;
    b.in.frame = planes;
    b.in.shown = planes + frame;
    bench_require(&ctx, gsf__mini_open(&ctx, o->mini, NULL, 0, &b.net));
    bench_require(&ctx, gsf__mini_begin(&ctx, &b.net, 1, REFERENCES, WIDTH, HEIGHT, 0, &b.run));
    bench_row row = bench_make_row(name, o->level, threads, 0.0, 0.0, (double)pixels, "pixel");
    bench_time(o, &ctx, &row, bench_run_mini, &b, 1.0);
    bench_print(o->json, &row);
    gsf__mini_end(&b.run);
    gsf__mini_close(&ctx, &b.net);
    gsf_free(&ctx, planes);
}

int main(int argc, char** argv) {
    bench_options o;
    memset(&o, 0, sizeof o);
    for (int i = 1; i < argc; i++) {
        const char* value = i + 1 < argc ? argv[i + 1] : NULL;
        if (strcmp(argv[i], "--json") == 0) o.json = 1;
        else if (strcmp(argv[i], "--quick") == 0) o.quick = 1;
        else if (value && strcmp(argv[i], "--filter") == 0) o.filter = argv[++i];
        else if (value && strcmp(argv[i], "--threads") == 0) o.threads = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--isa") == 0) o.level = bench_level_of(argv[++i]);
        else if (value && strcmp(argv[i], "--model") == 0) o.model = argv[++i];
        else if (value && strcmp(argv[i], "--mini") == 0) o.mini = argv[++i];
        else if (value && strcmp(argv[i], "--pipeline") == 0 && o.pipeline_count < 4)
            o.pipelines[o.pipeline_count++] = argv[++i];
        else {
            fprintf(stderr, "usage: bench_nn [--json] [--quick] [--filter TEXT] [--threads N] [--isa NAME] "
                            "[--model FOLDER] [--pipeline FOLDER]... [--mini FILE]\n");
            return 2;
        }
    }
    gsf_context ctx;
    (void)bench_context(&ctx, GSF_CPU_AMX, 1); // lowered to the machine's highest
    bench_best_level = ctx.cpu_level;
    (void)bench_context(&ctx, o.level ? o.level : bench_best_level, 1);
    o.level = ctx.cpu_level; // limited to what the machine supports
    const size_t size = (size_t)1 << (o.quick ? 28 : 30); // larger than any cache
    char* memory = (char*)bench_alloc(&ctx, size, 1);
    bench_fill(memory, size, GSF_NN_F32, 1);
    for (int threads = 1; threads <= 2; threads++) {
        if (o.threads && o.threads != threads) continue;
        BENCH_EACH(level) bench_machine(&o, level, threads);
    }
    if (o.mini || o.model || o.pipeline_count) {
        gsf_free(&ctx, memory);
        for (int threads = 1; o.mini && threads <= 2; threads++) bench_one_mini(&o, threads);
        if (o.mini) return 0;
        if (o.model) bench_whole_model(&o);
        else bench_pipelines(&o);
        return 0;
    }
    bench_linears(&o, memory, size);
    bench_int8s(&o, memory, size);
    gsf_free(&ctx, memory);
    bench_attentions(&o);
    bench_norms(&o);
    bench_convs(&o);
    bench_gradients(&o);
    bench_blocks(&o);
    bench_captions(&o);
    bench_t5s(&o);
    bench_encoders(&o);
    return 0;
}
