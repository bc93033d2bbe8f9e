// Linear layers against sums in double: odd shapes, all weight dtypes at any alignment, strides, every epilogue, all
// instruction sets; bit-identical for any number of workers; NaN and infinity; invalid arguments; failing allocations.
#define GSF__LINEAR_PACKED 20000 // so that even small layers take several groups of outputs
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"
#include "activation.h"

typedef struct layer { // every buffer is a block of exactly its size, so that ASan detects any overrun
    gsf__nn_linear_desc desc;
    gsf_nn_tensor weight, bias;
    float *x, *y, *gate, *before;
    char *weight_block, *bias_block;
    double *w, *b; // values after conversion from the dtype
    int64_t in, out;
    size_t y_count;
} layer;

static uint64_t seed = 1;

// `count` values of `dtype`, `offset` bytes into a block; *wide receives the same values in double.
static char* make_values(gsf_nn_dtype dtype, int64_t count, size_t offset, double** wide, gsf_nn_tensor* tensor) {
    const size_t size = gsf_nn_get_dtype_size(dtype);
    char* block = (char*)malloc(offset + (size_t)count * size);
    *wide = (double*)malloc((size_t)count * sizeof(double));
    for (int64_t i = 0; i < count; i++) {
        const float value = (float)test_random_in(&seed, -1.0, 1.0);
        const uint16_t half = gsf__float_to_half(value), brain = gsf__float_to_bf16(value);
        const void* bits = dtype == GSF_NN_F16 ? (const void*)&half : (const void*)&brain;
        if (dtype == GSF_NN_F32) bits = &value;
        memcpy(block + offset + (size_t)i * size, bits, size);
        (*wide)[i] = dtype == GSF_NN_F32 ? (double)value : (double)gsf__bf16_to_float(brain);
        if (dtype == GSF_NN_F16) (*wide)[i] = test_half(half);
    }
    memset(tensor, 0, sizeof *tensor);
    tensor->name = "made";
    tensor->data = block + offset;
    tensor->dtype = dtype;
    tensor->count = count;
    return block;
}

static layer make_layer(int64_t rows, int64_t in, int64_t out, gsf_nn_dtype dtype, size_t offset, int64_t gap) {
    layer l;
    memset(&l, 0, sizeof l);
    l.in = in;
    l.out = out;
    l.weight_block = make_values(dtype, in * out, offset, &l.w, &l.weight);
    l.weight.rank = 2;
    l.weight.shape[0] = out;
    l.weight.shape[1] = in;
    l.bias_block = make_values(dtype, out, offset, &l.b, &l.bias);
    l.bias.rank = 1;
    l.bias.shape[0] = out;
    l.desc.rows = rows;
    l.desc.ldx = gap ? in + gap : 0;
    l.desc.ldy = gap ? out + 2 * gap : 0;
    const size_t x_count = (size_t)((rows - 1) * (in + gap) + in);
    l.y_count = (size_t)((rows - 1) * (out + 2 * gap) + out);
    l.x = (float*)malloc(x_count * sizeof(float));
    l.y = (float*)malloc(l.y_count * sizeof(float));
    l.before = (float*)malloc(l.y_count * sizeof(float));
    l.gate = (float*)malloc((size_t)out * sizeof(float));
    for (size_t i = 0; i < x_count; i++) l.x[i] = (float)test_random_in(&seed, -1.0, 1.0);
    for (size_t i = 0; i < l.y_count; i++) l.before[i] = (float)test_random_in(&seed, -1.0, 1.0);
    for (int64_t i = 0; i < out; i++) l.gate[i] = (float)test_random_in(&seed, -1.0, 1.0);
    l.desc.x = l.x;
    l.desc.y = l.y;
    return l;
}

static void free_layer(layer* l) {
    free(l->weight_block);
    free(l->bias_block);
    free(l->w);
    free(l->b);
    free(l->x);
    free(l->y);
    free(l->before);
    free(l->gate);
}

static void run(gsf_context* ctx, gsf__nn_workspace* workspace, layer* l) {
    l->desc.weight = &l->weight; // set here because layers are copied
    memcpy(l->y, l->before, l->y_count * sizeof(float));
    CHECK_OK(ctx, gsf__nn_run_linear(ctx, workspace, &l->desc));
}

// Checks every value of y, and that the padding between its rows is unchanged; looks at up to `most` rows.
static void check_layer(const layer* l, int64_t most) {
    const gsf__nn_linear_desc* d = &l->desc;
    const int64_t ldx = d->ldx ? d->ldx : l->in, ldy = d->ldy ? d->ldy : l->out;
    const int64_t step = d->rows > most ? d->rows / most : 1;
    double worst = 0.0;
    for (int64_t m = 0; m < d->rows; m += step)
        for (int64_t n = 0; n < l->out; n++) {
            double sum = 0.0, size = 0.0;
            for (int64_t k = 0; k < l->in; k++) {
                const double product = (double)l->x[m * ldx + k] * l->w[n * l->in + k];
                sum += product;
                size += fabs(product);
            }
            if (d->bias) sum += l->b[n];
            const double before = (double)l->before[m * ldy + n], value = activation_of(d->activation, sum);
            const double gate = d->gate ? (double)d->gate[n] : 1.0;
            const double expected = d->gate || d->accumulate ? before + gate * value : value;
            const double allowed = 1e-6 * (fabs(gate) * (size + fabs(sum)) + fabs(before)) + 1e-30;
            const double error = fabs((double)l->y[m * ldy + n] - expected) / allowed;
            if (!(error <= worst)) worst = error; // NaN wins
        }
    CHECK(worst <= 1.0);
    if (!(worst <= 1.0))
        fprintf(stderr, "    %lld x %lld x %lld, %s, activation %d: %g of what is allowed\n", (long long)d->rows,
                (long long)l->in, (long long)l->out, gsf__nn_dtype_name(l->weight.dtype), (int)d->activation, worst);
    int touched = 0;
    for (int64_t m = 0; m + 1 < d->rows; m++)
        for (int64_t n = l->out; n < ldy; n++) touched += l->y[m * ldy + n] != l->before[m * ldy + n];
    CHECK(touched == 0);
}

static const gsf_nn_dtype dtypes[] = {GSF_NN_F32, GSF_NN_BF16, GSF_NN_F16};

static void test_shapes(gsf_context* ctx) {
    static const int64_t rows[] = {1, 2, 3, 4, 5, 6, 7, 11, 12, 13, 37, 100};
    static const int64_t sizes[] = {1, 2, 3, 7, 8, 9, 15, 16, 17, 31, 33, 64, 100, 193, 255, 257, 512, 513};
    gsf__nn_workspace workspace;
    memset(&workspace, 0, sizeof workspace);
    for (int i = 0; i < 300; i++) {
        const int64_t m = rows[i % (int)GSF__COUNT(rows)];
        const int64_t in = sizes[test_random_bits(&seed) % GSF__COUNT(sizes)];
        const int64_t out = sizes[test_random_bits(&seed) % GSF__COUNT(sizes)];
        layer l = make_layer(m, in, out, dtypes[i / 3 % 3], i % 4 == 3 ? 1 + (size_t)(i % 7) : 0, i % 5 == 4 ? 3 : 0);
        l.desc.activation = (gsf__nn_activation)(i / 5 % GSF__NN_ACTIVATION_COUNT);
        l.desc.bias = test_random_bits(&seed) % 3 ? &l.bias : NULL;
        l.desc.gate = test_random_bits(&seed) % 3 ? NULL : l.gate;
        l.desc.accumulate = test_random_bits(&seed) % 3 == 0;
        if (i >= 150) { // values that bf16 represents exactly
            const size_t count = (size_t)((m - 1) * (l.desc.ldx ? l.desc.ldx : in) + in);
            l.desc.bf16 = 1;
            for (size_t k = 0; k < count; k++) l.x[k] = gsf__bf16_to_float(gsf__float_to_bf16(l.x[k]));
        }
        run(ctx, i % 2 ? &workspace : NULL, &l);
        check_layer(&l, 25);
        free_layer(&l);
    }
    gsf__nn_destroy_workspace(ctx, &workspace);
}

// The error of rounding x to bf16 where the kernels round it, and none where they do not.
static void test_bf16(gsf_context* ctx) {
    for (int dtype = GSF_NN_F32; dtype <= GSF_NN_F16; dtype++)
        for (int64_t rows = 4; rows <= 40; rows += 36) {
            layer l = make_layer(rows, 512, 100, (gsf_nn_dtype)dtype, 0, 0);
            const int rounds = ctx->cpu_level >= GSF_CPU_AVX512_BF16 && dtype == GSF_NN_BF16 && rows > 4;
            float* exact = (float*)malloc(l.y_count * sizeof(float));
            double error = 0.0, size = 0.0;
            run(ctx, NULL, &l);
            memcpy(exact, l.y, l.y_count * sizeof(float));
            l.desc.bf16 = 1;
            run(ctx, NULL, &l);
            for (size_t i = 0; i < l.y_count; i++) {
                error += ((double)l.y[i] - (double)exact[i]) * ((double)l.y[i] - (double)exact[i]);
                size += (double)exact[i] * (double)exact[i];
            }
            const double relative = sqrt(error / size);
            CHECK(rounds ? relative > 1e-4 && relative < 2e-3 : relative == 0.0);
            free(exact);
            free_layer(&l);
        }
}

// Each row has one value, of either place in a pair, beside a zero or an infinity: bf16 keeps both, even where the processor
// takes denormal floats for zero.
static void test_bf16_pairs(gsf_context* ctx) {
    layer l = make_layer(37, 70, 20, GSF_NN_BF16, 0, 0);
    for (int infinite = 0; infinite < 2; infinite++) {
        for (int64_t m = 0; m < 37; m++)
            for (int64_t k = 0; k < 70; k++) l.x[m * 70 + k] = k == m ? 0.5f : infinite && k == (m ^ 1) ? INFINITY : 0.0f;
        int wrong = 0;
        l.desc.bf16 = 1;
        run(ctx, NULL, &l);
        for (int64_t m = 0; m < 37; m++)
            for (int64_t n = 0; n < 20; n++) {
                const double expected = infinite ? (l.w[n * 70 + (m ^ 1)] > 0.0 ? INFINITY : -INFINITY) : 0.5 * l.w[n * 70 + m];
                wrong += (double)l.y[m * 20 + n] != expected;
            }
        CHECK(wrong == 0);
    }
    free_layer(&l);
}

// Sizes at which the work is split: several blocks of rows, groups of outputs, blocks of outputs.
static void test_blocks(gsf_context* ctx) {
    static const int64_t sizes[][3] = {{320, 40, 400}, {321, 70, 300}, {400, 300, 90}, {650, 13, 1600},
                                       {330, 2100, 20}, {4, 2100, 250}, {1, 2100, 250}, {2, 1040, 33}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++)
        for (int t = 0; t < 3; t++) {
            layer l = make_layer(sizes[i][0], sizes[i][1], sizes[i][2], dtypes[t], (size_t)t, t == 1);
            l.desc.bias = &l.bias;
            l.desc.activation = (gsf__nn_activation)t;
            l.desc.gate = t == 2 ? l.gate : NULL;
            run(ctx, NULL, &l);
            check_layer(&l, 20);
            free_layer(&l);
        }
}

static void test_workers(gsf_cpu_level level) {
    static const int64_t sizes[][3] = {{1, 300, 2000}, {3, 70, 5000}, {50, 100, 700}, {400, 130, 500}};
    gsf_context one, three;
    memset(&one, 0, sizeof one);
    memset(&three, 0, sizeof three);
    one.threads = 1;
    one.cpu_level = three.cpu_level = level;
    work_backwards(&three);
    CHECK_OK(&one, gsf_init_context(&one));
    CHECK_OK(&three, gsf_init_context(&three));
    for (size_t i = 0; i < GSF__COUNT(sizes); i++)
        for (int t = 0; t < 3; t++) {
            layer l = make_layer(sizes[i][0], sizes[i][1], sizes[i][2], dtypes[t], 0, 0);
            l.desc.bias = &l.bias;
            l.desc.activation = GSF__NN_SILU;
            l.desc.bf16 = 1;
            run(&one, NULL, &l);
            float* first = (float*)malloc(l.y_count * sizeof(float));
            memcpy(first, l.y, l.y_count * sizeof(float));
            run(&three, NULL, &l);
            CHECK(memcmp(first, l.y, l.y_count * sizeof(float)) == 0);
            free(first);
            free_layer(&l);
        }
}

// A NaN or an infinity appears in the outputs that depend on it and in no others.
static void test_special(gsf_context* ctx) {
    static const int64_t rows[] = {1, 3, 7, 330};
    for (size_t i = 0; i < GSF__COUNT(rows); i++)
        for (int kind = 0; kind < 6; kind++) { // NaN, inf, -inf in x, then in w
            const int64_t in = 37, out = 21, bad_row = rows[i] / 2, bad_column = 18, bad_k = kind % 2 ? 36 : 5;
            const double bad = kind % 3 == 0 ? NAN : kind % 3 == 1 ? INFINITY : -INFINITY;
            const int in_x = kind < 3;
            layer l = make_layer(rows[i], in, out, GSF_NN_BF16, 0, 0);
            if (in_x) l.x[bad_row * in + bad_k] = (float)bad;
            else {
                const uint16_t bits = gsf__float_to_bf16((float)bad);
                memcpy((char*)(uintptr_t)l.weight.data + 2 * (bad_column * in + bad_k), &bits, 2);
            }
            run(ctx, NULL, &l);
            int wrong = 0;
            for (int64_t m = 0; m < rows[i]; m++)
                for (int64_t n = 0; n < out; n++) {
                    const float y = l.y[m * out + n];
                    const int hit = in_x ? m == bad_row : n == bad_column;
                    wrong += hit ? (kind % 3 == 0 ? y == y : fabsf(y) <= FLT_MAX) : !(fabsf(y) <= FLT_MAX);
                }
            CHECK(wrong == 0);
            free_layer(&l);
        }
}

static void test_bad_arguments(gsf_context* ctx) {
    layer l = make_layer(5, 6, 7, GSF_NN_F32, 0, 0);
    l.desc.weight = &l.weight;
    gsf__nn_linear_desc d;
#define REFUSED(change, code)                                                  \
    do {                                                                       \
        const gsf_nn_tensor weight = l.weight;                                    \
        d = l.desc;                                                            \
        ctx->error[0] = 0;                                                     \
        change;                                                                \
        CHECK_RESULT(ctx, gsf__nn_run_linear(ctx, NULL, &d), code);                 \
        CHECK(strstr(ctx->error, "linear") != NULL);                           \
        l.weight = weight;                                                     \
    } while (0)
    REFUSED(d.x = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(d.y = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(d.weight = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(d.rows = -1, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(d.ldx = 5, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(d.ldy = 6, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(l.weight.data = NULL, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(l.weight.rank = 1, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(l.weight.shape[0] = 0, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(l.weight.shape[0] = 5, GSF_ERROR_INVALID_ARGUMENT);
    REFUSED(l.weight.dtype = GSF_NN_I8, GSF_ERROR_UNSUPPORTED);
    REFUSED(l.weight.dtype = GSF_NN_F64, GSF_ERROR_UNSUPPORTED);
    REFUSED((l.bias.count = 6, d.bias = &l.bias), GSF_ERROR_INVALID_ARGUMENT);
    REFUSED((l.weight.count = INT64_MAX / 7 * 7, d.rows = INT64_MAX), GSF_ERROR_OUT_OF_MEMORY);
    memcpy(l.y, l.before, l.y_count * sizeof(float));
    d = l.desc;
    d.rows = 0; // nothing to compute
    CHECK_OK(ctx, gsf__nn_run_linear(ctx, NULL, &d));
    CHECK(memcmp(l.y, l.before, l.y_count * sizeof(float)) == 0);
    free_layer(&l);
}

static void test_memory(void) {
    counter count;
    memset(&count, 0, sizeof count);
    gsf_context ctx;
    test_context_zero(&ctx);
    count_memory(&ctx, &count);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    static const int64_t rows[] = {2, 20, 350};
    for (int i = 0; i < 3; i++) {
        layer l = make_layer(rows[i], 50, 60, GSF_NN_BF16, 0, 0);
        l.desc.weight = &l.weight;
        for (size_t k = 1;; k++) {
            count.calls = 0;
            count.fail_at = k;
            const gsf_result result = gsf__nn_run_linear(&ctx, NULL, &l.desc);
            CHECK(count.live == 0);
            if (result == GSF_OK) break;
            if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
        }
        gsf__nn_workspace workspace;
        memset(&workspace, 0, sizeof workspace);
        count.fail_at = 0;
        run(&ctx, &workspace, &l);
        const size_t calls = count.calls;
        run(&ctx, &workspace, &l); // the workspace is large enough already
        CHECK(count.calls == calls && count.live == 1);
        gsf__nn_destroy_workspace(&ctx, &workspace);
        CHECK(count.live == 0);
        free_layer(&l);
    }
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
        test_shapes(&ctx);
        test_bf16(&ctx);
        test_bf16_pairs(&ctx);
        test_blocks(&ctx);
        test_workers(ctx.cpu_level);
        test_special(&ctx);
        test_bad_arguments(&ctx);
    }
    test_memory();
    return test_report();
}
