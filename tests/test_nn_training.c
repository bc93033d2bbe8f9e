// Gradients of layers against central differences of the layers in double: odd sizes, single rows, strides, optional vectors,
// all instruction sets; bit-identical for any number of workers; failing allocations. Prints the worst relative L2 errors.
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"
#include "activation.h"

enum { LINEAR, NORM, SOFTMAX, ACTIVATE, ATTENTION, KINDS };
static const char* const kind_names[KINDS] = {"linear", "norm", "softmax", "activation", "attention"};
static double worst[KINDS];
static uint64_t layer_seed = 1;

// A layer in double and its loss, the sum of y * dy. p: x, weight, bias, scale, shift, one after another from `at`.
typedef struct made_layer {
    int kind, option;          // option: bits of the norm's vectors and RMS; the activation
    int64_t rows, in, out, gap, at[6];
    double* p;
    float *values, *dy, *grad, *spare; // grad: as p
} made_layer;

static double layer_loss(const made_layer* m) {
    double total = 0.0;
    for (int64_t r = 0; r < m->rows; r++) {
        const double *x = m->p + r * (m->in + m->gap), *v[4];
        const float* dy = m->dy + r * m->out;
        double mean = 0.0, square = 0.0, sum = 0.0;
        for (int i = 0; i < 4; i++) v[i] = m->p + m->at[i + 1];
        for (int64_t i = 0; i < m->in; i++) mean += x[i] / (double)m->in;
        if (m->option & 16) mean = 0.0;
        for (int64_t i = 0; i < m->in; i++) square += (x[i] - mean) * (x[i] - mean) / (double)m->in;
        for (int64_t i = 0; i < m->in; i++) sum += exp(0.7 * x[i]);
        for (int64_t o = 0; o < m->out; o++) {
            double y = 0.0;
            if (m->kind == LINEAR) {
                y = v[1][o];
                for (int64_t i = 0; i < m->in; i++) y += x[i] * v[0][o * m->in + i];
            } else if (m->kind == NORM) {
                y = (x[o] - mean) / sqrt(square + (double)1e-5f);
                y = y * (m->option & 1 ? v[0][o] : 1.0) + (m->option & 2 ? v[1][o] : 0.0);
                y = y * (m->option & 4 ? 1.0 + v[2][o] : 1.0) + (m->option & 8 ? v[3][o] : 0.0);
            } else if (m->kind == SOFTMAX) y = exp(0.7 * x[o]) / sum;
            else y = activation_of((gsf__nn_activation)m->option, x[o]);
            total += y * (double)dy[o];
        }
    }
    return total;
}

static made_layer make(int kind, int64_t rows, int64_t in, int64_t out, int64_t gap, int option) {
    made_layer m = {kind, option, rows, in, out, gap, {0}, NULL, NULL, NULL, NULL, NULL};
    m.at[1] = rows * (in + gap);
    m.at[2] = m.at[1] + (kind == LINEAR ? in * out : out);
    for (int i = 3; i < 6; i++) m.at[i] = m.at[i - 1] + out;
    const size_t count = (size_t)m.at[5], results = (size_t)(rows * out);
    m.p = (double*)malloc(count * sizeof(double));
    m.values = (float*)malloc(count * sizeof(float));
    m.grad = (float*)calloc(count, sizeof(float));
    m.spare = (float*)malloc(results * sizeof(float));
    m.dy = (float*)malloc(results * sizeof(float));
    for (size_t i = 0; i < count; i++) m.p[i] = (double)(m.values[i] = (float)test_random_in(&layer_seed, -2.0, 2.0));
    for (size_t i = 0; i < results; i++) m.dy[i] = (float)test_random_in(&layer_seed, -1.0, 1.0);
    return m;
}

static void free_made(made_layer* m) {
    free(m->p); free(m->values); free(m->grad); free(m->spare); free(m->dy);
}

static gsf_result backward(gsf_context* ctx, const made_layer* m) {
    const float* v[6];
    float* g[6];
    for (int i = 0; i < 6; i++) {
        v[i] = m->values + m->at[i];
        g[i] = m->grad + m->at[i];
    }
    memset(m->grad, 0, (size_t)m->at[5] * sizeof(float));
    if (m->kind == LINEAR) {
        const int64_t shape[2] = {m->out, m->in};
        const gsf_nn_tensor weight = gsf_nn_wrap_tensor("weight", v[1], 2, shape);
        float* dx = m->gap ? NULL : m->grad; // with a gap only the weights' gradients
        const gsf__nn_linear_grad_desc d = {v[0], m->rows, m->in + m->gap, &weight, m->dy, dx, 0, g[1], g[2], 0};
        return gsf__nn_linear_grad(ctx, NULL, &d);
    }
    if (m->kind == NORM) {
        const int o = m->option;
        const gsf__nn_norm_grad_desc d = {v[0], m->rows, m->in, {o & 1 ? v[1] : NULL, o & 2 ? v[2] : NULL,
                                          o & 4 ? v[3] : NULL, o & 8 ? v[4] : NULL}, 1e-5f, o & 16, m->dy, g[0], 0,
                                          o & 1 ? g[1] : NULL, o & 2 ? g[2] : NULL, o & 4 ? g[3] : NULL, o & 8 ? g[4] : NULL};
        return gsf__nn_norm_grad(ctx, &d);
    }
    if (m->kind == SOFTMAX) {
        gsf__nn_softmax(ctx, v[0], m->rows, m->in, 0.7f, m->spare);
        gsf__nn_softmax_grad(ctx, m->spare, m->dy, m->rows, m->in, 0.7f, g[0]);
    } else gsf__nn_activate_grad(ctx, (gsf__nn_activation)m->option, v[0], m->dy, m->rows * m->in, g[0]);
    return GSF_OK;
}

static void check_layer(gsf_context* ctx, int kind, int64_t rows, int64_t in, int64_t out, int64_t gap, int option) {
    made_layer m = make(kind, rows, in, out, gap, option);
    CHECK_OK(ctx, backward(ctx, &m));
    double scale = 0.0; // of all gradients of the layer: some are zero or nearly so
    double error = 0.0;
    const int64_t count = kind == ACTIVATE ? m.at[1] : m.at[5]; // activations have no parameters
    for (int64_t i = gap ? m.at[1] : 0; i < count; i++) {
        const double before = m.p[i], step = 1e-4;
        m.p[i] = before + step;
        const double above = layer_loss(&m);
        m.p[i] = before - step;
        const double slope = (above - layer_loss(&m)) / (2.0 * step);
        m.p[i] = before;
        if (kind == ACTIVATE && option == GSF__NN_RELU && fabs(before) < 2.0 * step) continue;
        // A slope passes through zero near -0.75: a single value there would have a gradient of rounding errors only.
        scale += kind == ACTIVATE ? (double)m.dy[i] * (double)m.dy[i] : slope * slope;
        error += (slope - (double)m.grad[i]) * (slope - (double)m.grad[i]);
    }
    error = scale > 0.0 ? sqrt(error / scale) : sqrt(error);
    if (error > worst[kind]) worst[kind] = error;
    CHECK_NEAR(error, 0.0, 1e-5);
    gsf_context others; // workers in another order
    memset(&others, 0, sizeof others);
    others.cpu_level = ctx->cpu_level;
    work_backwards(&others);
    CHECK_OK(&others, gsf_init_context(&others));
    made_layer again = m;
    again.grad = (float*)malloc((size_t)m.at[5] * sizeof(float));
    CHECK_OK(&others, backward(&others, &again));
    CHECK(memcmp(again.grad, m.grad, (size_t)m.at[5] * sizeof(float)) == 0);
    free(again.grad);
    free_made(&m);
}

static double attention_loss(const double* p, const float* dy, int64_t queries, int64_t keys, int heads, int dim) {
    const int64_t width = (int64_t)heads * dim;
    const double *key = p + queries * width, *value = key + keys * width;
    double total = 0.0;
    for (int64_t n = 0; n < queries * heads; n++) {
        double sum = 0.0, weighted = 0.0;
        for (int64_t j = 0; j < keys; j++) {
            double s = 0.0, t = 0.0;
            for (int64_t i = 0; i < dim; i++) {
                s += p[n * dim + i] * key[j * width + n % heads * dim + i];
                t += (double)dy[n * dim + i] * value[j * width + n % heads * dim + i];
            }
            sum += exp(s / sqrt((double)dim));
            weighted += exp(s / sqrt((double)dim)) * t;
        }
        total += weighted / sum;
    }
    return total;
}

static gsf_result attend_backward(gsf_context* ctx, const gsf__nn_attention_desc* forward, const float* dy, float* g) {
    const int64_t width = (int64_t)forward->heads * forward->head_dim;
    gsf__nn_attention_desc d = *forward;
    d.out = (float*)malloc((size_t)(d.queries * width) * sizeof(float));
    d.lse = (float*)malloc((size_t)(d.queries * d.heads) * sizeof(float));
    const gsf__nn_attention_grad_desc desc = {&d, dy, g, g + d.queries * width, g + (d.queries + d.keys) * width};
    gsf_result result = gsf__nn_run_attention(ctx, NULL, &d);
    if (!result) result = gsf__nn_attention_grad(ctx, &desc);
    free(d.out);
    free(d.lse);
    return result;
}

// Large ones: of every few values only. Keys get an offset that all share, which softmax does not see.
static void test_attention(gsf_context* ctx, int64_t queries, int64_t keys, int heads, int dim, double offset, int bf16) {
    const int64_t width = (int64_t)heads * dim, count = (queries + 2 * keys) * width;
    const int64_t step = count / test_few(300, 40) + 1;
    float *values = (float*)malloc((size_t)(4 * count) * sizeof(float)), *dy = values + count;
    float* grad[2] = {dy + count, dy + 2 * count};
    double *p = (double*)malloc((size_t)count * sizeof(double)), scale = 0.0, error = 0.0;
    for (int64_t i = 0; i < count; i++) {
        const int is_key = i >= queries * width && i < (queries + keys) * width;
        p[i] = (double)(values[i] = (float)(test_random_in(&layer_seed, -1.5, 1.5) + (is_key ? offset : 0.0)));
        dy[i] = (float)test_random_in(&layer_seed, -1.0, 1.0);
    }
    gsf_context others;
    memset(&others, 0, sizeof others);
    others.cpu_level = ctx->cpu_level;
    work_backwards(&others);
    CHECK_OK(&others, gsf_init_context(&others));
    gsf__nn_attention_desc d;
    memset(&d, 0, sizeof d);
    d.queries = queries;
    d.keys = keys;
    d.heads = heads;
    d.head_dim = dim;
    d.q = values;
    d.k = values + queries * width;
    d.v = d.k + keys * width;
    d.bf16 = bf16;
    for (int i = 0; i < 2; i++)
        CHECK_OK(i ? &others : ctx, attend_backward(i ? &others : ctx, &d, dy, grad[i]));
    CHECK(memcmp(grad[0], grad[1], (size_t)count * sizeof(float)) == 0);
    for (int64_t i = 0; i < count; i += step) {
        const double before = p[i], h = 1e-4;
        p[i] = before + h;
        const double above = attention_loss(p, dy, queries, keys, heads, dim);
        p[i] = before - h;
        const double slope = (above - attention_loss(p, dy, queries, keys, heads, dim)) / (2.0 * h);
        p[i] = before;
        scale += slope * slope;
        error += (slope - (double)grad[0][i]) * (slope - (double)grad[0][i]);
    }
    error = sqrt(error / scale);
    if (bf16) { // rounds where the processor multiplies such values
        CHECK_NEAR(error, 0.0, 1e-2);
        if (ctx->cpu_level == GSF_CPU_AVX512_BF16 || ctx->cpu_level == GSF_CPU_AMX) CHECK(error > 1e-4);
    } else {
        if (error > worst[ATTENTION]) worst[ATTENTION] = error;
        CHECK_NEAR(error, 0.0, 1e-5);
    }
    free(values);
    free(p);
}

// Gradients of a linear layer in bf16 are those in float32 if bf16 holds all operands; others are rounded, not with few rows.
static void test_bf16_linear(gsf_context* ctx, int64_t rows, int64_t in, int64_t out) {
    gsf_context others; // workers in another order
    memset(&others, 0, sizeof others);
    others.cpu_level = ctx->cpu_level;
    work_backwards(&others);
    CHECK_OK(&others, gsf_init_context(&others));
    for (int exact = 0; exact < 2; exact++) {
        made_layer m = make(LINEAR, rows, in, out, 0, 0);
        const int64_t count = m.at[5], results = rows * out;
        float* grads[3];
        for (int64_t i = 0; i < count && exact; i++) m.values[i] = gsf__bf16_to_float(gsf__float_to_bf16(m.values[i]));
        for (int64_t i = 0; i < results && exact; i++) m.dy[i] = gsf__bf16_to_float(gsf__float_to_bf16(m.dy[i]));
        const int64_t shape[2] = {out, in};
        const gsf_nn_tensor weight = gsf_nn_wrap_tensor("weight", m.values + m.at[1], 2, shape);
        for (int i = 0; i < 3; i++) { // float32, bf16, bf16 with other workers
            grads[i] = (float*)calloc((size_t)count, sizeof(float));
            const gsf__nn_linear_grad_desc d = {m.values, rows, in, &weight, m.dy, grads[i], 0, grads[i] + m.at[1],
                                                grads[i] + m.at[2], i ? GSF__NN_BF16_ALL : 0};
            CHECK_OK(i == 2 ? &others : ctx, gsf__nn_linear_grad(i == 2 ? &others : ctx, NULL, &d));
        }
        CHECK(memcmp(grads[1], grads[2], (size_t)count * sizeof(float)) == 0);
        double error = 0.0, size = 0.0;
        for (int64_t i = 0; i < count; i++) {
            error += ((double)grads[1][i] - (double)grads[0][i]) * ((double)grads[1][i] - (double)grads[0][i]);
            size += (double)grads[0][i] * (double)grads[0][i];
        }
        error = sqrt(error / size);
        const int rounds = !exact && rows > 4 && (ctx->cpu_level == GSF_CPU_AVX512_BF16 || ctx->cpu_level == GSF_CPU_AMX);
        CHECK(rounds ? error > 1e-4 && error < 5e-3 : error < 1e-6);
        for (int i = 0; i < 3; i++) free(grads[i]);
        free_made(&m);
    }
}

static void test_layer_memory(void) {
    counter count;
    memset(&count, 0, sizeof count);
    gsf_context ctx;
    test_context_zero(&ctx);
    count_memory(&ctx, &count);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    for (int kind = LINEAR; kind <= NORM; kind++) {
        made_layer m = make(kind, 9, 20, 20, 0, 15);
        for (size_t k = 1;; k++) {
            count.calls = 0;
            count.fail_at = k;
            const gsf_result result = backward(&ctx, &m);
            CHECK(count.live == 0);
            if (result == GSF_OK) break;
            if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
        }
        count.fail_at = 0;
        m.rows = -1;
        CHECK_RESULT(&ctx, backward(&ctx, &m), GSF_ERROR_INVALID_ARGUMENT);
        free_made(&m);
    }
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    const gsf_cpu_level best = ctx.cpu_level;
    static const int64_t sizes[][2] = {{1, 1}, {1, 17}, {2, 8}, {5, 33}, {67, 7}};
    for (int level = GSF_CPU_SCALAR; level <= (int)best; level++) {
        memset(&ctx, 0, sizeof ctx);
        ctx.cpu_level = (gsf_cpu_level)level;
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        if ((int)ctx.cpu_level != level) continue;
        for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
            const int64_t rows = sizes[i][0], in = sizes[i][1];
            check_layer(&ctx, LINEAR, rows, in, 1, 0, 0);
            check_layer(&ctx, LINEAR, rows, in, 19, 0, 0);
            check_layer(&ctx, LINEAR, rows, in, 13, 3, 0);
            if (in > 1) { // the norm of a single value is constant
                check_layer(&ctx, NORM, rows, in, in, 0, 0);
                check_layer(&ctx, NORM, rows, in, in, 0, 3);
                check_layer(&ctx, NORM, rows, in, in, 0, 15);
                check_layer(&ctx, NORM, rows, in, in, 0, 17);
                check_layer(&ctx, SOFTMAX, rows, in, in, 0, 0);
            }
            for (int a = 0; a < GSF__NN_ACTIVATION_COUNT; a++) check_layer(&ctx, ACTIVATE, rows, in, in, 0, a);
        }
        test_attention(&ctx, 1, 1, 1, 1, 0.0, 0);
        test_attention(&ctx, 7, 7, 3, 5, 0.0, 0);
        test_attention(&ctx, 3, 19, 2, 8, 4.0, 0); // cross attention
        test_attention(&ctx, 100, 35, 1, 17, 0.0, 0); // more queries, then more keys than a block
        test_attention(&ctx, 5, 131, 2, 16, -3.0, 0);
        test_attention(&ctx, 193, 257, 1, 64, 0.0, 0);
        test_attention(&ctx, 193, 257, 1, 64, 0.0, 1);
        test_attention(&ctx, 50, 35, 2, 32, 4.0, 1);
        test_attention(&ctx, 100, 131, 1, 17, 0.0, 1);
        test_attention(&ctx, 1, 3, 1, 2, 0.0, 1);
        test_attention(&ctx, 97, 129, 1, 144, 0.0, 1);
        static const int64_t linear[][3] = {{3, 40, 19},   {5, 33, 19},  {67, 40, 130},   {200, 65, 48},
                                            {333, 15, 3}, {31, 600, 70}, {330, 1100, 270}, {270, 1090, 340}};
        for (size_t i = 0; i < GSF__COUNT(linear); i++) test_bf16_linear(&ctx, linear[i][0], linear[i][1], linear[i][2]);
    }
    test_layer_memory();
    for (int kind = 0; kind < KINDS; kind++) printf("%-10s worst relative L2 error %.2e\n", kind_names[kind], worst[kind]);
    return test_report();
}
