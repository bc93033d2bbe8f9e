// 8-bit linear layers: the scalar kernels against integers computed here; bit-identical for all instruction sets and
// workers; total error against sums in double, with and without outliers and rotation; every epilogue; NaN and
// infinity; invalid arguments; failing allocations.
#define GSF__INT8_HELD 3000 // so that only a few rows are quantised at a time
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"
#include "activation.h"

typedef struct layer { // every buffer is a block of exactly its size, so that ASan detects any overrun
    gsf__nn_linear_desc desc;
    gsf_nn_tensor weight, bias;
    float *x, *w, *y, *gate, *before, *bias_values;
    int64_t in, out;
    size_t y_count;
} layer;

static uint64_t seed = 1;

static double gaussian(void) { // Box-Muller transform
    return sqrt(-2.0 * log(1.0 - test_random(&seed))) * cos(6.283185307179586 * test_random(&seed));
}

static float* values(size_t count) {
    float* v = (float*)malloc((count ? count : 1) * sizeof(float));
    for (size_t i = 0; i < count; i++) v[i] = (float)gaussian();
    return v;
}

static layer make_layer(int64_t rows, int64_t in, int64_t out, int64_t gap) {
    layer l;
    memset(&l, 0, sizeof l);
    const int64_t shape[2] = {out, in};
    l.in = in;
    l.out = out;
    l.desc.rows = rows;
    l.desc.ldx = gap ? in + gap : 0;
    l.desc.ldy = gap ? out + 2 * gap : 0;
    l.y_count = (size_t)((rows - 1) * (out + 2 * gap) + out);
    l.w = values((size_t)(out * in));
    l.x = values((size_t)((rows - 1) * (in + gap) + in));
    l.before = values(l.y_count);
    l.gate = values((size_t)out);
    l.bias_values = values((size_t)out);
    l.y = (float*)malloc(l.y_count * sizeof(float));
    l.weight = gsf_nn_wrap_tensor("made.weight", l.w, 2, shape);
    l.bias = gsf_nn_wrap_tensor("made.bias", l.bias_values, 1, shape);
    l.desc.x = l.x;
    l.desc.y = l.y;
    return l;
}

static void free_layer(layer* l) {
    free(l->x);
    free(l->w);
    free(l->y);
    free(l->gate);
    free(l->before);
    free(l->bias_values);
}

static void run(gsf_context* ctx, gsf__nn_workspace* workspace, layer* l, const gsf__nn_quantized* q) {
    memcpy(l->y, l->before, l->y_count * sizeof(float));
    CHECK_OK(ctx, gsf__nn_run_linear_int8(ctx, workspace, &l->desc, q));
}

static void quantize(gsf_context* ctx, layer* l, int32_t no_rotation, gsf__nn_quantized* q) {
    CHECK_OK(ctx, gsf__nn_quantize_weight(ctx, &l->weight, no_rotation, q));
}

// The definition in double, before rounding to 8 bits: a Walsh-Hadamard rotation, whose signs are the parity of the
// bits that i and j share.
static void round_row(const float* x, int64_t count, int64_t block, double* q, double* scale) {
    double top = 0.0;
    for (int64_t k = 0; k < count; k++) {
        double sum = 0.0;
        for (int64_t j = 0; j < block; j++) {
            int64_t shared = j & (k % block), sign = 0;
            for (; shared; shared &= shared - 1) sign ^= 1;
            sum += (sign ? -1.0 : 1.0) * (double)x[k / block * block + j];
        }
        q[k] = sum;
        if (fabs(sum) > top) top = fabs(sum);
    }
    for (int64_t k = 0; k < count; k++) q[k] = top > 0.0 ? q[k] * 127.0 / top : 0.0; // rounding is left to the caller
    *scale = top / 127.0;
}

// Odd shapes, strides and epilogues against the definition. Where a value lies halfway between two integers, float and
// double may round differently, so the tolerance includes one quantization step for each such value.
static void test_definition(gsf_context* ctx) {
    static const int64_t rows[] = {1, 2, 3, 4, 5, 6, 7, 13, 40};
    static const int64_t ins[] = {1, 2, 3, 4, 6, 8, 13, 16, 24, 40, 64, 100, 128, 192, 256, 320, 512, 520, 768};
    static const int64_t outs[] = {1, 3, 8, 15, 16, 17, 33, 50};
    gsf__nn_workspace workspace;
    memset(&workspace, 0, sizeof workspace);
    for (int i = 0; i < 60; i++) {
        const int64_t m = rows[i % (int)GSF__COUNT(rows)], in = ins[i % (int)GSF__COUNT(ins)];
        const int64_t out = outs[test_random_bits(&seed) % GSF__COUNT(outs)];
        layer l = make_layer(m, in, out, i % 5 == 4 ? 3 : 0);
        gsf__nn_quantized q;
        quantize(ctx, &l, i % 4 == 3, &q);
        int64_t block = 1;
        while (i % 4 != 3 && block < 256 && in % (2 * block) == 0) block *= 2;
        CHECK(q.block == block && q.in == in && q.out == out);
        CHECK(q.bytes == (size_t)(gsf__round_up(out, 16) * (gsf__round_up(in, 4) + 8)));
        l.desc.activation = (gsf__nn_activation)(i / 5 % GSF__NN_ACTIVATION_COUNT);
        l.desc.bias = i % 2 ? &l.bias : NULL;
        l.desc.gate = i % 7 < 2 ? l.gate : NULL;
        l.desc.accumulate = i % 3 == 0;
        run(ctx, i % 2 ? &workspace : NULL, &l, &q);
        double *qx = (double*)malloc((size_t)in * sizeof(double)), *qw = (double*)malloc((size_t)in * sizeof(double)), sx, sw;
        const int64_t ldx = l.desc.ldx ? l.desc.ldx : in, ldy = l.desc.ldy ? l.desc.ldy : out;
        double worst = 0.0;
        for (int64_t r = 0; r < m; r++) {
            round_row(l.x + r * ldx, in, block, qx, &sx);
            for (int64_t n = 0; n < out; n++) {
                round_row(l.w + n * in, in, block, qw, &sw);
                double sum = 0.0, edge = 0.0;
                for (int64_t k = 0; k < in; k++) {
                    const double a = floor(qx[k] + 0.5), b = floor(qw[k] + 0.5);
                    sum += a * b;
                    if (fabs(fabs(qx[k] - a) - 0.5) < 1e-4) edge += fabs(b) + 1.0;
                    if (fabs(fabs(qw[k] - b) - 0.5) < 1e-4) edge += fabs(a) + 1.0;
                }
                const double unit = sx * sw / (double)block, bias = l.desc.bias ? (double)l.bias_values[n] : 0.0;
                const double value = activation_of(l.desc.activation, sum * unit + bias);
                const double gate = l.desc.gate ? (double)l.gate[n] : 1.0, before = (double)l.before[r * ldy + n];
                const double expected = l.desc.gate || l.desc.accumulate ? before + gate * value : value;
                const double size = fabs(sum) * unit + fabs(bias) + 127.0 * unit;
                const double allowed = fabs(gate) * (1.2 * edge * unit + 2e-6 * size) + 1e-6 * fabs(before);
                const double error = fabs((double)l.y[r * ldy + n] - expected) / allowed;
                if (!(error <= worst)) worst = error;
            }
        }
        CHECK(worst <= 1.0);
        if (!(worst <= 1.0))
            fprintf(stderr, "    %lld x %lld x %lld: %g of what is allowed\n", (long long)m, (long long)in, (long long)out,
                    worst);
        int touched = 0;
        for (int64_t r = 0; r + 1 < m; r++)
            for (int64_t n = out; n < ldy; n++) touched += l.y[r * ldy + n] != l.before[r * ldy + n];
        CHECK(touched == 0);
        free(qx);
        free(qw);
        gsf__nn_destroy_quantized(ctx, &q);
        CHECK(q.data == NULL && q.bytes == 0);
        free_layer(&l);
    }
    gsf__nn_destroy_workspace(ctx, &workspace);
}

// Relative error of the layer against the product of the unquantised values in double.
static double error_of(gsf_context* ctx, layer* l, int32_t no_rotation) {
    gsf__nn_quantized q;
    double difference = 0.0, square = 0.0;
    quantize(ctx, l, no_rotation, &q);
    run(ctx, NULL, l, &q);
    for (int64_t m = 0; m < l->desc.rows; m++)
        for (int64_t n = 0; n < l->out; n++) {
            double sum = 0.0;
            for (int64_t k = 0; k < l->in; k++) sum += (double)l->x[m * l->in + k] * (double)l->w[n * l->in + k];
            const double error = (double)l->y[m * l->out + n] - sum;
            difference += error * error;
            square += sum * sum;
        }
    gsf__nn_destroy_quantized(ctx, &q);
    return sqrt(difference / square);
}

// Gaussian values; then with one input in a hundred 20 times as large.
static void test_error(gsf_context* ctx) {
    layer l = make_layer(24, 3072, 48, 0);
    const double plain = error_of(ctx, &l, 1), rotated = error_of(ctx, &l, 0);
    CHECK(plain > 1.0e-2 && plain < 1.4e-2);
    CHECK(rotated > 1.0e-2 && rotated < 1.4e-2);
    for (int64_t i = 0; i < 30; i++) {
        const int64_t k = (int64_t)(test_random_bits(&seed) % 3072);
        for (int64_t m = 0; m < l.desc.rows; m++) l.x[m * l.in + k] *= 20.0f;
    }
    const double plain_outliers = error_of(ctx, &l, 1), rotated_outliers = error_of(ctx, &l, 0);
    CHECK(rotated_outliers > 0.9e-2 && rotated_outliers < 1.5e-2);
    CHECK(plain_outliers > 3.0e-2);
    printf("relative L2 error %.3g, rotated %.3g; with outliers %.3g, rotated %.3g\n", plain, rotated, plain_outliers,
           rotated_outliers);
    free_layer(&l);
}

// Weights of every dtype at any address are quantised to the same 8 bits as the floats that they represent.
static void test_types(gsf_context* ctx) {
    const int64_t in = 72, out = 21;
    for (int t = 0; t < 2; t++)
        for (size_t offset = 0; offset < 4; offset++) {
            layer l = make_layer(1, in, out, 0);
            gsf__nn_quantized a, b;
            char* block = (char*)malloc(offset + 2 * (size_t)(in * out));
            for (int64_t i = 0; i < in * out; i++) {
                const uint16_t bits = t ? gsf__float_to_bf16(l.w[i]) : gsf__float_to_half(l.w[i]);
                memcpy(block + offset + 2 * i, &bits, 2);
                l.w[i] = t ? gsf__bf16_to_float(bits) : gsf__half_to_float(bits);
            }
            quantize(ctx, &l, 0, &a);
            l.weight.data = block + offset;
            l.weight.dtype = t ? GSF_NN_BF16 : GSF_NN_F16;
            quantize(ctx, &l, 0, &b);
            CHECK(a.bytes == b.bytes && memcmp(a.data, b.data, a.bytes) == 0);
            gsf__nn_destroy_quantized(ctx, &a);
            gsf__nn_destroy_quantized(ctx, &b);
            free(block);
            free_layer(&l);
        }
}

// All CPU levels give the same quantised weights and bit-identical outputs, with one worker and with three. The sizes
// need several blocks of rows and outputs, several steps of depth and several groups of quantised rows. Only linear
// epilogues, as activations round differently per level.
static void test_same_bits(gsf_cpu_level best) {
    static const int64_t sizes[][3] = {{1, 300, 700}, {4, 1030, 900}, {3, 5, 40}, {7, 1, 5}, {13, 7, 3}, {6, 1024, 400},
                                       {50, 1044, 33}, {401, 130, 500},
                                       {200, 2048, 90}, {390, 96, 20}, {33, 12, 800}, {300, 704, 70}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
        layer l = make_layer(sizes[i][0], sizes[i][1], sizes[i][2], i % 2 ? 1 : 0);
        float* first = (float*)malloc(l.y_count * sizeof(float));
        char* first_weight = NULL;
        l.desc.bias = &l.bias;
        l.desc.accumulate = i % 3 == 2;
        for (int level = GSF_CPU_SCALAR; level <= (int)best; level++)
            for (int workers = 1; workers <= 3; workers += 2) {
                gsf_context ctx;
                gsf__nn_quantized q;
                memset(&ctx, 0, sizeof ctx);
                ctx.cpu_level = (gsf_cpu_level)level;
                ctx.threads = 1;
                if (workers == 3) work_backwards(&ctx);
                CHECK_OK(&ctx, gsf_init_context(&ctx));
                quantize(&ctx, &l, 0, &q);
                run(&ctx, NULL, &l, &q);
                if (!first_weight) {
                    first_weight = (char*)malloc(q.bytes);
                    memcpy(first_weight, q.data, q.bytes);
                    memcpy(first, l.y, l.y_count * sizeof(float));
                }
                CHECK(memcmp(first_weight, q.data, q.bytes) == 0);
                CHECK(memcmp(first, l.y, l.y_count * sizeof(float)) == 0);
                gsf__nn_destroy_quantized(&ctx, &q);
            }
        free(first_weight);
        free(first);
        free_layer(&l);
    }
}

// The kernels alone on operands of the largest magnitude, at which 16-bit sums of two unsigned products would overflow.
static void test_extremes(gsf_cpu_level best) {
    enum { COUNT = 1028, FEW = 2 };
    static int8_t w[16 * COUNT];
    static int16_t a[6 * COUNT], b[16 * COUNT];
    int32_t sums[GSF__TILE_SUMS];
    for (int level = GSF_CPU_SCALAR; level <= (int)best; level++) {
        const gsf__int8_kernels* kernels = gsf__int8_kernels_of((gsf_cpu_level)level, 0);
        const int is_unsigned = kernels->x_size == 1;
        for (int sign = -1; sign <= 1; sign += 2) {
            const uint32_t once = (uint32_t)(sign * 127 * (is_unsigned ? 255 : 127) * COUNT);
            memset(w, sign * 127, sizeof w);
            for (int i = 0; i < 6 * COUNT; i++) a[i] = 127;
            if (is_unsigned) memset(a, 255, sizeof a);
            if (kernels->widen) kernels->widen(w, COUNT, b);
            const void* panel = kernels->widen ? (const void*)b : w;
            kernels->tile(a, panel, COUNT, 0, sums);
            kernels->tile(a, panel, COUNT, 1, sums);
            int wrong = 0;
            for (int i = 0; i < GSF__TILE_SUMS; i++) wrong += (uint32_t)sums[i] != 2 * once;
            kernels->gemv(a, FEW, w, COUNT, sums);
            for (int i = 0; i < FEW * GSF__TILE_COLUMNS; i++) wrong += (uint32_t)sums[i] != once;
            CHECK(wrong == 0);
        }
    }
}

// The kernel for four tiles gives the same results as one tile at a time.
static void test_four_tiles(gsf_cpu_level best) {
    enum { COUNT = 52, GROUP = 6 * COUNT, PANEL = 16 * COUNT };
    uint8_t a[2 * GROUP];
    int8_t w[2 * PANEL];
    int32_t sums[4 * GSF__TILE_SUMS], alone[GSF__TILE_SUMS];
    for (int level = GSF_CPU_SCALAR; level <= (int)best; level++) {
        const gsf__int8_kernels* kernels = gsf__int8_kernels_of((gsf_cpu_level)level, 0);
        if (!kernels->four_tiles) continue;
        for (size_t i = 0; i < sizeof a; i++) a[i] = (uint8_t)(test_random_bits(&seed) >> 56);
        for (size_t i = 0; i < sizeof w; i++) w[i] = (int8_t)(test_random_bits(&seed) >> 56);
        for (int add = 0; add < 2; add++)
            kernels->four_tiles(a, GROUP, w, PANEL, COUNT, add, sums, 2 * GSF__TILE_SUMS, w, sizeof w);
        for (int t = 0; t < 4; t++) { // panel t / 2, group t % 2
            for (int add = 0; add < 2; add++) kernels->tile(a + t % 2 * GROUP, w + t / 2 * PANEL, COUNT, add, alone);
            CHECK(memcmp(alone, sums + t * GSF__TILE_SUMS, sizeof alone) == 0);
        }
    }
}

// A row with a NaN or an infinity gives NaNs and affects no other row; rows of zeros and of tiny values give the bias.
static void test_special(gsf_context* ctx) {
    const float bad[] = {NAN, -NAN, INFINITY, -INFINITY, 3e38f};
    const int64_t sizes[] = {5, 64, 256, 300};
    for (size_t i = 0; i < GSF__COUNT(bad); i++)
        for (size_t s = 0; s < GSF__COUNT(sizes); s++) {
            const int64_t in = sizes[s], rows = 15, out = 19;
            if (i == 4 && in == 5) continue; // no rotation, which would add up the large values
            layer l = make_layer(rows, in, out, 0);
            gsf__nn_quantized q;
            l.desc.bias = &l.bias;
            l.desc.activation = s == 3 ? GSF__NN_GELU_TANH : s == 2 ? GSF__NN_SILU : GSF__NN_LINEAR;
            quantize(ctx, &l, 0, &q);
            l.x[7 * in + (i % 2 ? in - 1 : 2)] = bad[i];
            if (i == 4) l.x[7 * in] = l.x[7 * in + 1] = l.x[7 * in + 3] = bad[i]; // finite, but their sum is infinite
            memset(l.x + 9 * in, 0, (size_t)in * sizeof(float));
            for (int64_t k = 0; k < in; k++) l.x[10 * in + k] = 1e-42f;
            run(ctx, NULL, &l, &q);
            int wrong = 0;
            for (int64_t m = 0; m < rows; m++)
                for (int64_t n = 0; n < out; n++) {
                    const float y = l.y[m * out + n];
                    if (m == 7) wrong += y == y;
                    else wrong += !(fabsf(y) <= FLT_MAX);
                    if ((m == 9 || m == 10) && l.desc.activation == GSF__NN_LINEAR) wrong += y != l.bias_values[n];
                }
            CHECK(wrong == 0);
            gsf__nn_destroy_quantized(ctx, &q);
            l.w[11 * in + in - 1] = bad[i];
            if (i < 4) {
                CHECK_RESULT(ctx, gsf__nn_quantize_weight(ctx, &l.weight, (int)(s % 2), &q), GSF_ERROR_NUMERIC);
                CHECK(strstr(ctx->error, "made.weight") != NULL && strstr(ctx->error, "row 11") != NULL);
                CHECK(q.data == NULL);
            }
            free_layer(&l);
        }
}

static void test_bad_arguments(gsf_context* ctx) {
    layer l = make_layer(5, 6, 7, 0);
    gsf__nn_quantized q, none;
    memset(&none, 0, sizeof none);
    quantize(ctx, &l, 0, &q);
#define REFUSED(call, change, code)                                            \
    do {                                                                       \
        gsf__nn_linear_desc d = l.desc;                                         \
        gsf_nn_tensor weight = l.weight, bias = l.bias;                           \
        d.bias = &bias;                                                        \
        ctx->error[0] = 0;                                                     \
        change;                                                                \
        CHECK_RESULT(ctx, call, code);                                         \
        CHECK(strstr(ctx->error, "int8") != NULL);                             \
        (void)weight;                                                          \
        (void)d;                                                               \
    } while (0)
#define LINEAR gsf__nn_run_linear_int8(ctx, NULL, &d, &q)
    REFUSED(LINEAR, d.x = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, d.y = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, d.rows = -1, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, d.ldx = 5, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, d.ldy = 6, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, bias.count = 6, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, bias.data = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(LINEAR, d.rows = INT64_MAX, GSF_ERROR_OUT_OF_MEMORY);
    REFUSED(gsf__nn_run_linear_int8(ctx, NULL, &d, NULL), (void)0, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(gsf__nn_run_linear_int8(ctx, NULL, &d, &none), (void)0, GSF_ERROR_INVALID_ARGUMENT);
#define QUANTIZE gsf__nn_quantize_weight(ctx, &weight, 0, &none)
    REFUSED(gsf__nn_quantize_weight(ctx, NULL, 0, &none), (void)0, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(QUANTIZE, weight.data = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(QUANTIZE, weight.rank = 1, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(QUANTIZE, weight.shape[0] = 0, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(QUANTIZE, weight.shape[0] = 5, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(QUANTIZE, weight.dtype = GSF_NN_F64, GSF_ERROR_UNSUPPORTED);
    REFUSED(QUANTIZE, (weight.shape[0] = 1, weight.count = 131073), GSF_ERROR_UNSUPPORTED);
    REFUSED(QUANTIZE, (weight.shape[0] = INT64_MAX / 4, weight.count = INT64_MAX / 4 * 4), GSF_ERROR_OUT_OF_MEMORY);
    l.desc.rows = 0; // nothing to compute
    run(ctx, NULL, &l, &q);
    CHECK(memcmp(l.y, l.before, l.y_count * sizeof(float)) == 0);
    gsf__nn_destroy_quantized(ctx, &q);
    free_layer(&l);
}

static void test_memory(void) {
    counter count;
    gsf_context ctx;
    memset(&count, 0, sizeof count);
    test_context_zero(&ctx);
    count_memory(&ctx, &count);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    layer l = make_layer(20, 50, 60, 0);
    size_t failed = 0;
    for (size_t k = 1;; k++, failed++) {
        gsf__nn_quantized q;
        count.calls = 0;
        count.fail_at = k;
        gsf_result result = gsf__nn_quantize_weight(&ctx, &l.weight, 0, &q);
        if (result == GSF_OK) {
            result = gsf__nn_run_linear_int8(&ctx, NULL, &l.desc, &q);
            CHECK(count.live == 1);
            gsf__nn_destroy_quantized(&ctx, &q);
        }
        CHECK(count.live == 0);
        if (result == GSF_OK) break;
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
    CHECK(failed == 3);
    gsf__nn_quantized q;
    gsf__nn_workspace workspace;
    memset(&workspace, 0, sizeof workspace);
    count.fail_at = 0;
    quantize(&ctx, &l, 0, &q);
    run(&ctx, &workspace, &l, &q);
    const size_t calls = count.calls;
    run(&ctx, &workspace, &l, &q); // the workspace is large enough already
    CHECK(count.calls == calls && count.live == 2);
    gsf__nn_destroy_workspace(&ctx, &workspace);
    gsf__nn_destroy_quantized(&ctx, &q);
    CHECK(count.live == 0);
    free_layer(&l);
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    const gsf_cpu_level best = ctx.cpu_level;
    for (int level = GSF_CPU_SCALAR; level <= (int)best; level++) {
        memset(&ctx, 0, sizeof ctx);
        ctx.cpu_level = (gsf_cpu_level)level;
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        if ((int)ctx.cpu_level != level) continue;
        test_definition(&ctx);
        test_error(&ctx);
        test_types(&ctx);
        test_special(&ctx);
        test_bad_arguments(&ctx);
    }
    test_same_bits(best);
    test_extremes(best);
    test_four_tiles(best);
    test_memory();
    return test_report();
}
