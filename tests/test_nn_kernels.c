// Kernels of gsfixer_nn.h against direct double-precision references: odd sizes, tails and strides, special values,
// in-place operation; bit-identical for one and three workers; out of memory. Every check runs at each CPU level of the
// machine.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"
#include "activation.h"

static gsf_context one, three; // one worker; three workers that run chunks in shuffled order
static uint64_t kernel_seed = 5;

static int open_contexts(gsf_cpu_level level) { // 0: the machine lacks the level
    test_context_zero(&one);
    if (one.cpu_level != GSF_CPU_AUTO && one.cpu_level != level) return 0;
    one.cpu_level = level;
    one.threads = 1;
    three = one;
    work_backwards(&three);
    CHECK(gsf_init_context(&one) == GSF_OK && gsf_init_context(&three) == GSF_OK);
    return one.cpu_level == level;
}

static float* make_floats(size_t count, double lo, double hi) {
    float* v = (float*)malloc((count ? count : 1) * sizeof(float));
    for (size_t i = 0; i < count; i++) v[i] = (float)test_random_in(&kernel_seed, lo, hi);
    return v;
}

static double* make_doubles(size_t count) { return (double*)calloc(count ? count : 1, sizeof(double)); }

static float* copy_floats(const float* v, size_t count) {
    float* out = (float*)malloc((count ? count : 1) * sizeof(float));
    memcpy(out, v, count * sizeof(float));
    return out;
}

static int same_bits(const float* a, const float* b, size_t count) { return memcmp(a, b, count * sizeof(float)) == 0; }

// ---- vector --------------------------------------------------------------------

#if GSF__X86
GSF__TARGET_AVX2 static void exp8(const float* x, int base, float* y) { // base 0: e
    const __m256 v = _mm256_loadu_ps(x);
    _mm256_storeu_ps(y, base ? gsf__v_exp2_avx2(v) : gsf__v_exp_avx2(v));
}

static void check_exp(void) {
    const float special[8] = {0.0f, -0.0f, INFINITY, -INFINITY, NAN, 1e30f, -1e30f, -90.0f};
    float x[8], y[8];
    for (int base = 0; base <= 2; base += 2) {
        const double factor = base ? 1.0 : 1.4426950408889634, step = base ? 0.00037 : 0.00026;
        double worst = 0.0;
        for (double from = -127.0 / factor; from < 128.1 / factor; from += 8 * step) {
            for (int i = 0; i < 8; i++) x[i] = (float)(from + i * step);
            exp8(x, base, y);
            for (int i = 0; i < 8; i++) {
                const double expected = base ? exp2((double)x[i]) : exp((double)x[i]);
                if (expected < 1.7e-38)
                    CHECK(y[i] >= 0.0f && y[i] <= 1.7e-38f);
                else if (expected > (double)FLT_MAX * (1.0 + 3e-8))
                    CHECK(y[i] == INFINITY);
                else if (expected < (double)FLT_MAX * (1.0 - 2e-7)) // near the limit both are correct
                    worst = fmax(worst, fabs((double)y[i] - expected) / expected);
            }
        }
        test_check_near(worst, 0.0, 2e-7, base ? "relative error of exp2" : "relative error of exp", __FILE__, __LINE__);
        if (getenv("TEST_VERBOSE")) printf("exp%d %g\n", base, worst);
        exp8(special, base, y);
        CHECK(y[0] == 1.0f && y[1] == 1.0f && y[2] == INFINITY && y[3] == 0.0f && y[4] != y[4]);
        CHECK(y[5] == INFINITY && y[6] == 0.0f);
        if (!base) CHECK(y[7] == 0.0f);
    }
}
#endif

// ---- activations ---------------------------------------------------------------

// GELU's relative error, between where results are too small for one and where they equal x.
static void check_gelu(void) {
    enum { COUNT = 400000 };
    float *x = make_floats(COUNT, -14.0, 7.0), *y = make_floats(COUNT, 0, 1);
    double worst = 0.0;
    for (size_t i = 0; i < COUNT / 8; i++) x[i] *= 0.001f;
    gsf__nn_activate(&one, GSF__NN_GELU, x, COUNT, y);
    for (size_t i = 0; i < COUNT; i++) {
        const double expected = activation_of(GSF__NN_GELU, (double)x[i]), size = fabs(expected);
        if (size > 1e-36) worst = fmax(worst, fabs((double)y[i] - expected) / size);
        else CHECK(fabs((double)y[i] - expected) <= 1e-36);
    }
    test_check_near(worst, 0.0, 1e-6, "relative error of GELU", __FILE__, __LINE__);
    if (getenv("TEST_VERBOSE")) printf("gelu %g\n", worst);
    free(x); free(y);
}

static void check_activate(void) {
    static const size_t sizes[] = {0, 1, 7, 8, 9, 31, 70003};
    for (size_t s = 0; s < sizeof sizes / sizeof sizes[0]; s++)
        for (int k = 0; k < GSF__NN_ACTIVATION_COUNT; k++) {
            const gsf__nn_activation kind = (gsf__nn_activation)k;
            const size_t n = sizes[s];
            float *x = make_floats(n, -15.0, 15.0), *y = make_floats(n + 1, 0, 1), *z = copy_floats(x, n);
            double* expected = make_doubles(n);
            const float after = y[n];
            for (size_t i = 0; i < n; i++) expected[i] = activation_of(kind, (double)x[i]);
            gsf__nn_activate(&one, kind, x, (int64_t)n, y);
            test_compare_floats("activate", y, expected, n, 2e-6);
            gsf__nn_activate(&three, kind, z, (int64_t)n, z);
            CHECK(same_bits(y, z, n) && y[n] == after);
            free(x); free(y); free(z); free(expected);
        }
    const float x[9] = {INFINITY, -INFINITY, NAN, FLT_MAX, -FLT_MAX, 1e3f, -1e3f, 0.0f, NAN};
    for (int k = GSF__NN_LINEAR + 1; k < GSF__NN_ACTIVATION_COUNT; k++) {
        float y[9];
        gsf__nn_activate(&one, (gsf__nn_activation)k, x, 9, y);
        CHECK(y[0] == INFINITY && y[1] == 0.0f && y[2] != y[2] && y[3] == FLT_MAX && y[4] == 0.0f);
        CHECK(y[5] == 1e3f && y[6] == 0.0f && y[7] == 0.0f && y[8] != y[8]);
    }
}

static void check_softmax(void) {
    static const int64_t sizes[][2] = {{1, 1}, {5, 7}, {3, 8}, {2, 777}, {9, 100}, {300, 129}, {2, 40000}};
    for (size_t s = 0; s < sizeof sizes / sizeof sizes[0]; s++)
        for (int sign = -1; sign <= 1; sign += 2) {
            const int64_t rows = sizes[s][0], columns = sizes[s][1];
            const size_t n = (size_t)(rows * columns);
            const float scale = (float)sign * 0.7f;
            float *x = make_floats(n, -20.0, 20.0), *y = make_floats(n, 0, 1), *z = copy_floats(x, n);
            double* expected = make_doubles(n);
            for (int64_t r = 0; r < rows; r++) {
                double top = -INFINITY, sum = 0.0;
                for (int64_t i = r * columns; i < (r + 1) * columns; i++) top = fmax(top, (double)scale * (double)x[i]);
                for (int64_t i = r * columns; i < (r + 1) * columns; i++)
                    sum += expected[i] = exp((double)scale * (double)x[i] - top);
                for (int64_t i = r * columns; i < (r + 1) * columns; i++) expected[i] /= sum;
            }
            gsf__nn_softmax(&one, x, rows, columns, scale, y);
            test_compare_floats("softmax", y, expected, n, 2e-6 * test_max_abs(expected, n));
            gsf__nn_softmax(&three, z, rows, columns, scale, z);
            CHECK(same_bits(y, z, n));
            free(x); free(y); free(z); free(expected);
        }
    float x[13], y[13];
    for (int i = 0; i < 13; i++) x[i] = (float)i * 1e4f;
    gsf__nn_softmax(&one, x, 1, 13, 1.0f, y);
    CHECK(y[12] == 1.0f && y[0] == 0.0f && y[11] == 0.0f);
    x[3] = NAN;
    gsf__nn_softmax(&one, x, 1, 13, 1.0f, y);
    for (int i = 0; i < 13; i++) CHECK(y[i] != y[i]);
}

// ---- norms ---------------------------------------------------------------------

static void norm_of(const float* x, size_t n, int centre, double eps, double* y) {
    double mean = 0.0, square = 0.0;
    for (size_t i = 0; centre && i < n; i++) mean += (double)x[i];
    mean /= (double)n;
    for (size_t i = 0; i < n; i++) square += ((double)x[i] - mean) * ((double)x[i] - mean);
    for (size_t i = 0; i < n; i++) y[i] = ((double)x[i] - mean) / sqrt(square / (double)n + eps);
}

typedef struct norm_case { int64_t rows, dim; double lo, hi; } norm_case;

static void check_row_norms(void) {
    static const norm_case cases[] = {{1, 1, -1, 1},       {3, 5, -1, 1},          {70, 64, -2, 3},
                                      {2, 3072, -1, 1},    {5, 37, 9999, 10001},   {33, 1921, 99, 100},
                                      {3, 40001, -1e15, 1e15}, {4, 19, 1.0, 1.000001}};
    for (size_t c = 0; c < sizeof cases / sizeof cases[0]; c++)
        for (int way = 0; way < 6; way++) { // plain, weight, weight and bias, modulated, all, root mean square
            const size_t rows = (size_t)cases[c].rows, dim = (size_t)cases[c].dim, n = rows * dim;
            const float eps = 1e-6f;
            float *x = make_floats(n, cases[c].lo, cases[c].hi), *y = make_floats(n, 0, 1), *z = copy_floats(x, n);
            float *w = make_floats(dim, 0.5, 2), *b = make_floats(dim, -1, 1), *scale = make_floats(dim, -1, 1);
            float* shift = make_floats(dim, -1, 1);
            const int with_w = way != 0 && way != 3, with_b = way == 2 || way == 4, with_m = way == 3 || way == 4;
            const float *pw = with_w ? w : NULL, *pb = with_b ? b : NULL, *ps = with_m ? scale : NULL;
            double* expected = make_doubles(n);
            for (size_t r = 0; r < rows; r++) {
                norm_of(x + r * dim, dim, way != 5, (double)eps, expected + r * dim);
                for (size_t i = 0; i < dim; i++) {
                    double* e = &expected[r * dim + i];
                    if (with_w) *e *= (double)w[i];
                    if (with_b) *e += (double)b[i];
                    if (with_m) *e = *e * (1.0 + (double)scale[i]) + (double)shift[i];
                }
            }
            gsf_context* contexts[2] = {&one, &three};
            for (int k = 0; k < 2; k++) { // in place the second time
                float *in = k ? z : x, *out = k ? z : y;
                if (way == 5) gsf__nn_rms_norm(contexts[k], in, (int64_t)rows, (int64_t)dim, pw, eps, out);
                else if (with_m)
                    gsf__nn_layer_norm_modulated(contexts[k], in, (int64_t)rows, (int64_t)dim, pw, pb, eps, ps, shift,
                                                 out);
                else gsf__nn_layer_norm(contexts[k], in, (int64_t)rows, (int64_t)dim, pw, pb, eps, out);
            }
            test_compare_floats("row norm", y, expected, n, 5e-7 * fmax(1.0, test_max_abs(expected, n)));
            CHECK(same_bits(y, z, n));
            x[n - 1] = NAN;
            gsf__nn_layer_norm(&one, x, (int64_t)rows, (int64_t)dim, pw, pb, eps, y);
            for (size_t i = n - dim; i < n; i++) CHECK(y[i] != y[i]);
            CHECK(rows == 1 || y[n - dim - 1] == y[n - dim - 1]);
            free(x); free(y); free(z); free(w); free(b); free(scale); free(shift); free(expected);
        }
    float before[1];
    gsf__nn_layer_norm(&one, before + 1, 3, 0, NULL, NULL, 1e-6f, before + 1); // must not read
}

static void check_group_norm(void) {
    static const int64_t cases[][3] = { // channels, values of each, groups
        {1, 1, 1}, {6, 35, 3}, {8, 1, 4}, {4, 9, 4}, {32, 1000, 32}, {12, 9001, 2}, {1, 300007, 1},
        {6, 600001, 3}};
    for (size_t c = 0; c < sizeof cases / sizeof cases[0]; c++)
        for (int way = 0; way < 2; way++) {
            const size_t channels = (size_t)cases[c][0], count = (size_t)cases[c][1], groups = (size_t)cases[c][2];
            const size_t n = channels * count, per = n / groups;
            float *x = make_floats(n, 999.0, 1000.0), *y = make_floats(n, 0, 1), *z = copy_floats(x, n);
            float *w = make_floats(channels, 0.5, 2), *b = make_floats(channels, -1, 1);
            double* expected = make_doubles(n);
            for (size_t g = 0; g < groups; g++) norm_of(x + g * per, per, 1, 1e-6, expected + g * per);
            for (size_t i = 0; way && i < n; i++)
                expected[i] = expected[i] * (double)w[i / count] + (double)b[i / count];
            const float *pw = way ? w : NULL, *pb = way ? b : NULL;
            const int64_t c0 = cases[c][0], c1 = cases[c][1], c2 = cases[c][2];
            gsf__nn_group_norm(&one, x, c0, c1, c2, pw, pb, 1e-6f, y);
            test_compare_floats("group norm", y, expected, n, 5e-7 * fmax(1.0, test_max_abs(expected, n)));
            gsf__nn_group_norm(&three, z, c0, c1, c2, pw, pb, 1e-6f, z);
            CHECK(same_bits(y, z, n));
            x[per - 1] = INFINITY;
            gsf__nn_group_norm(&three, x, c0, c1, c2, NULL, NULL, 1e-6f, y);
            CHECK(y[0] != y[0] && y[per - 1] != y[per - 1]);
            CHECK(groups == 1 || y[per] == y[per]);
            free(x); free(y); free(z); free(w); free(b); free(expected);
        }
}

enum { LARGE_CHANNELS = 8, LARGE_COUNT = GSF__NN_STREAM / LARGE_CHANNELS + 96, LARGE_DIM = 256 };
enum { LARGE = LARGE_CHANNELS * LARGE_COUNT };

static void run_large(gsf_context* ctx, int kind, const float* x, const float* w, float* y) {
    if (kind == 0) gsf__nn_layer_norm(ctx, x, LARGE / LARGE_DIM, LARGE_DIM, w, w, 1e-6f, y);
    if (kind == 1) gsf__nn_group_norm(ctx, x, LARGE_CHANNELS, LARGE_COUNT, 2, w, w, 1e-6f, y);
    if (kind == 2) gsf__nn_activate(ctx, GSF__NN_GELU, x, LARGE, y);
}

// Aligned results larger than any cache are written with non-temporal stores: the same bits as those of unaligned ones.
static void check_streams(void) {
    float *x = make_floats(LARGE, -3, 3), *w = make_floats(LARGE_DIM, 0.5, 2), *memory = make_floats(LARGE + 32, 0, 1);
    float* aligned = memory + (64 - (uintptr_t)memory % 64) % 64 / sizeof(float);
    CHECK(gsf__nn_streams(x, aligned, LARGE, LARGE_DIM) && !gsf__nn_streams(x, aligned + 1, LARGE, LARGE_DIM));
    for (int kind = 0; kind < 3; kind++) {
        float* in_place = copy_floats(x, LARGE);
        run_large(&one, kind, in_place, w, in_place);
        run_large(&three, kind, x, w, aligned);
        CHECK(same_bits(aligned, in_place, LARGE));
        run_large(&one, kind, x, w, aligned + 1);
        CHECK(same_bits(aligned + 1, in_place, LARGE));
        free(in_place);
    }
    free(x);
    free(w);
    free(memory);
}

static void check_head_norm_rope(void) {
    static const int64_t cases[][5] = { // rows, heads, dim, extra columns, first row that is rotated (-1: none)
        {1, 1, 2, 0, 0}, {9, 3, 6, 5, 4}, {7, 2, 64, 0, 7}, {300, 4, 40, 3, 17}, {5, 3, 13, 1, 2}, {6, 2, 16, 0, -1}};
    for (size_t c = 0; c < sizeof cases / sizeof cases[0]; c++) {
        const size_t rows = (size_t)cases[c][0], heads = (size_t)cases[c][1], dim = (size_t)cases[c][2];
        const size_t ld = heads * dim + (size_t)cases[c][3], n = rows * ld;
        const int64_t first = cases[c][4];
        float *x = make_floats(n, -2, 2), *y = copy_floats(x, n);
        float *w = make_floats(dim, 0.5, 2), *b = make_floats(dim, -1, 1);
        float *cosine = make_floats(rows * dim, -1, 1), *sine = make_floats(rows * dim, -1, 1);
        double *expected = make_doubles(n), *head = make_doubles(dim);
        for (size_t i = 0; i < n; i++) expected[i] = (double)x[i];
        for (size_t r = 0; r < rows; r++)
            for (size_t h = 0; h < heads; h++) {
                double* e = expected + r * ld + h * dim;
                norm_of(x + r * ld + h * dim, dim, 1, 1e-5, head);
                for (size_t i = 0; i < dim; i++) e[i] = head[i] = head[i] * (double)w[i] + (double)b[i];
                if (first < 0 || r < (size_t)first) continue;
                const float *co = cosine + (r - (size_t)first) * dim, *si = sine + (r - (size_t)first) * dim;
                for (size_t i = 0; i + 1 < dim; i += 2) {
                    e[i] = head[i] * (double)co[i] - head[i + 1] * (double)si[i];
                    e[i + 1] = head[i + 1] * (double)co[i + 1] + head[i] * (double)si[i + 1];
                }
            }
        gsf__nn_head_norm_rope(&one, x, (int64_t)rows, (int64_t)ld, (int32_t)heads, (int32_t)dim, w, b, 1e-5f,
                               first < 0 ? NULL : cosine, first < 0 ? NULL : sine, first < 0 ? 0 : first);
        test_compare_floats("head norm", x, expected, n, 2e-6);
        gsf__nn_head_norm_rope(&three, y, (int64_t)rows, (int64_t)ld, (int32_t)heads, (int32_t)dim, w, b, 1e-5f,
                               first < 0 ? NULL : cosine, first < 0 ? NULL : sine, first < 0 ? 0 : first);
        CHECK(same_bits(x, y, n));
        free(x); free(y); free(w); free(b); free(cosine); free(sine); free(expected); free(head);
    }
}

// ---- attention -----------------------------------------------------------------

typedef struct attention_case {
    int64_t queries, keys;
    int32_t heads, dim;
    int64_t extra; // padding columns between rows
    int masked;
    float scale, range; // of q and k
    float bias;         // range of the bias added to the logits; 0: none
} attention_case;

typedef struct attention_data {
    gsf__nn_attention_desc desc;
    float *q, *k, *v, *bias, *out;
    unsigned char* mask;
    size_t q_count, k_count;
} attention_data;

static attention_data make_attention(const attention_case* c) {
    attention_data a;
    memset(&a, 0, sizeof a);
    const int64_t width = (int64_t)c->heads * c->dim, ld = width + c->extra;
    a.q_count = (size_t)(c->queries * ld);
    a.k_count = (size_t)(c->keys * ld);
    a.q = make_floats(a.q_count, -c->range, c->range);
    a.k = make_floats(a.k_count, -c->range, c->range);
    a.v = make_floats(a.k_count, -1, 2);
    a.out = make_floats(a.q_count, 7, 8);
    if (c->masked) {
        const size_t n = (size_t)(c->heads * c->queries * c->keys);
        a.mask = (unsigned char*)malloc(n);
        for (size_t i = 0; i < n; i++) a.mask[i] = test_random(&kernel_seed) < 0.4;
        for (int64_t j = 0; j < c->keys; j++) a.mask[j] = 0; // the first query has all keys masked
        for (int64_t j = 0; j < c->keys; j++) a.mask[(c->queries - 1) * c->keys + j] = j == c->keys - 1;
    }
    if (c->bias != 0.0f) a.bias = make_floats((size_t)(c->heads * c->queries * c->keys), -c->bias, c->bias);
    gsf__nn_attention_desc* d = &a.desc;
    d->queries = c->queries;
    d->keys = c->keys;
    d->heads = c->heads;
    d->head_dim = c->dim;
    d->q = a.q;
    d->k = a.k;
    d->v = a.v;
    d->out = a.out;
    d->mask = a.mask;
    d->bias = a.bias;
    d->scale = c->scale;
    if (c->extra) d->ldq = d->ldk = d->ldv = d->ldo = ld;
    return a;
}

static void free_attention(attention_data* a) {
    free(a->q); free(a->k); free(a->v); free(a->out); free(a->bias); free(a->mask);
}

static int attention_rounds(const attention_data* a) { // operands to bfloat16
    return a->desc.bf16 && one.cpu_level >= GSF_CPU_AVX512_BF16 && a->desc.head_dim % 2 == 0;
}

static double attention_operand(const attention_data* a, float value, float factor) {
    if (!attention_rounds(a)) return (double)value;
    return (double)gsf__bf16_to_float(gsf__float_to_bf16(value * factor)) / (double)factor;
}

static void attention_of(const attention_case* c, const attention_data* a, double* out) { // (queries, heads * dim)
    const int64_t dim = c->dim, width = c->heads * dim, ld = width + c->extra;
    const double scale = c->scale != 0.0f ? (double)c->scale : 1.0 / sqrt((double)dim);
    const float factor = (float)scale * 1.44269504f; // factor that queries are multiplied by before rounding
    double* p = make_doubles((size_t)c->keys);
    float* center = (float*)calloc((size_t)width, sizeof(float)); // keys are rounded as differences from this centre
    for (int64_t i = 0; i < width && attention_rounds(a); i++) {
        float mean[3] = {0.0f, 0.0f, 0.0f};
        for (int64_t n = 0; n < 15; n++) mean[n % 3] += a->k[n * c->keys / 15 * ld + i];
        for (int g = 0; g < 3; g++) mean[g] /= 5.0f;
        center[i] = fmaxf(fminf(mean[0], mean[1]), fminf(fmaxf(mean[0], mean[1]), mean[2]));
    }
    for (int64_t h = 0; h < c->heads; h++)
        for (int64_t r = 0; r < c->queries; r++) {
            double top = -INFINITY, sum = 0.0;
            for (int64_t j = 0; j < c->keys; j++) {
                p[j] = 0.0;
                for (int64_t i = 0; i < dim; i++)
                    p[j] += attention_operand(a, a->q[r * ld + h * dim + i], factor) *
                            attention_operand(a, a->k[j * ld + h * dim + i] - center[h * dim + i], 1.0f);
                p[j] *= scale;
                if (a->bias) p[j] += (double)a->bias[(h * c->queries + r) * c->keys + j];
                if (a->mask && !a->mask[(h * c->queries + r) * c->keys + j]) p[j] = -INFINITY;
                top = fmax(top, p[j]);
            }
            for (int64_t j = 0; j < c->keys; j++) sum += p[j] = top == -INFINITY ? 0.0 : exp(p[j] - top);
            for (int64_t i = 0; i < dim; i++) {
                double value = 0.0;
                for (int64_t j = 0; j < c->keys; j++) value += p[j] * attention_operand(a, a->v[j * ld + h * dim + i], 1.0f);
                out[r * width + h * dim + i] = sum > 0.0 ? value / sum : 0.0;
            }
        }
    free(p);
    free(center);
}

static float* dense_rows(const attention_case* c, const float* x) { // without the padding columns
    const int64_t width = (int64_t)c->heads * c->dim;
    float* out = (float*)malloc((size_t)(c->queries * width) * sizeof(float));
    for (int64_t r = 0; r < c->queries; r++)
        memcpy(out + r * width, x + r * (width + c->extra), (size_t)width * sizeof(float));
    return out;
}

static void check_attention(void) {
    static const attention_case cases[] = {
        {1, 1, 1, 1, 0, 0, 0, 1, 0},     {7, 5, 2, 3, 0, 0, 0, 1, 0},     {13, 300, 1, 64, 0, 0, 0, 1, 0},
        {6, 16, 1, 8, 0, 0, -1, 1, 0},   {49, 513, 2, 72, 1, 0, 0, 1, 0}, {50, 257, 3, 40, 5, 0, 0.3f, 1, 0},
        {803, 70, 3, 16, 0, 0, 0, 1, 0}, {30, 33, 2, 24, 2, 1, 0, 1, 0},  {9, 600, 1, 20, 0, 1, 0, 1, 0},
        {5, 700, 1, 64, 0, 0, 0, 30, 0}, {1541, 20, 1, 4, 0, 0, 0, 1, 0}, {48, 256, 1, 128, 0, 0, 0, 1, 0},
        {57, 300, 2, 24, 1, 0, 1, 1, 3}, {9, 270, 3, 20, 0, 1, 0, 1, 2},  {803, 33, 2, 8, 0, 0, 0, 1, 9},
        {50, 257, 3, 96, 5, 0, 0.3f, 1, 0}, {77, 300, 2, 32, 1, 0, 1, 1, 3}, {30, 271, 2, 64, 2, 1, 0, 1, 0},
        {803, 31, 2, 32, 0, 0, 0, 1, 9}};
    for (size_t n = 0; n < 2 * GSF__COUNT(cases); n++) {
        const attention_case* c = &cases[n / 2];
        const size_t values = (size_t)(c->queries * c->heads * c->dim);
        attention_data a = make_attention(c);
        a.desc.bf16 = n % 2;
        // the weights are rounded, too: 2^-9 relative error in numerator and in denominator; values span up to 3
        const double rounding = attention_rounds(&a) ? 3.0 / 256 : 0.0;
        double* expected = make_doubles(values);
        gsf__nn_workspace workspace;
        memset(&workspace, 0, sizeof workspace);
        attention_of(c, &a, expected);
        CHECK_OK(&one, gsf__nn_run_attention(&one, &workspace, &a.desc));
        float* dense = dense_rows(c, a.out);
        char what[80];
        snprintf(what, sizeof what, "attention case %zu%s", n / 2, n % 2 ? " bf16" : "");
        // logits up to 1500
        test_compare_floats(what, dense, expected, values, rounding + (c->range > 10 ? 3e-4 : 3e-6));
        if (rounding > 0.0 && c->keys > 200 && !c->masked && c->range < 10) { // rounding is visible, but averages out
            double square = 0.0;
            for (size_t i = 0; i < values; i++) square += ((double)dense[i] - expected[i]) * ((double)dense[i] - expected[i]);
            CHECK(square > 1e-12 * (double)values && square < 1e-6 * (double)values);
        }
        for (int64_t r = 0; c->extra && r < c->queries; r++) // padding is not written
            CHECK(a.out[r * (c->heads * c->dim + c->extra) + c->heads * c->dim] >= 7.0f);
        a.desc.out = a.q; // in place, with three workers and scratch memory for this call only
        CHECK_OK(&three, gsf__nn_run_attention(&three, NULL, &a.desc));
        float* again = dense_rows(c, a.q);
        CHECK(same_bits(dense, again, values));
        gsf__nn_destroy_workspace(&one, &workspace);
        free(dense); free(again); free(expected);
        free_attention(&a);
    }
}

static int all_nan(const float* x, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (x[i] == x[i]) return 0;
    return 1;
}
static int none_nan(const float* x, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (x[i] != x[i]) return 0;
    return 1;
}

// Softmax ignores an offset that all keys share: the error is within a few times that without the offset, in bf16 too.
static void check_attention_offset(void) {
    static const attention_case cases[] = {{9, 13, 2, 64, 0, 0, 0, 1, 0}, {49, 513, 2, 72, 1, 0, 0, 1, 0},
                                           {7, 5, 2, 3, 0, 0, 0, 1, 0},   {30, 33, 2, 24, 2, 1, 0, 1, 0}};
    static const float offsets[] = {50.0f, -1000.0f};
    for (size_t n = 0; n < 4 * GSF__COUNT(cases); n++) {
        const attention_case* c = &cases[n / 4];
        const size_t values = (size_t)(c->queries * c->heads * c->dim);
        attention_data a = make_attention(c);
        a.desc.bf16 = n % 2;
        for (size_t i = 0; i < a.k_count; i++) a.k[i] += offsets[n / 2 % 2];
        double* expected = make_doubles(values);
        attention_of(c, &a, expected);
        CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
        float* dense = dense_rows(c, a.out);
        char what[80];
        snprintf(what, sizeof what, "attention case %zu, keys at %g%s", n / 4, (double)offsets[n / 2 % 2],
                 n % 2 ? " bf16" : "");
        test_compare_floats(what, dense, expected, values, attention_rounds(&a) ? 3.0 / 256 : 2e-6);
        free(dense); free(expected);
        free_attention(&a);
    }
}

static void check_attention_values(int bf16) {
    const attention_case c = {20, 300, 2, 24, 0, 0, 0, 1, 0};
    const size_t width = 48;
    for (int key = 0; key < 300; key += 299) { // in the first and in the last block
        attention_data a = make_attention(&c);
        a.desc.bf16 = bf16;
        a.q[3 * width + 5] = NAN; // query 3 of head 0
        CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
        CHECK(all_nan(a.out + 3 * width, 24) && none_nan(a.out + 3 * width + 24, 24) && none_nan(a.out, 3 * width));
        CHECK(none_nan(a.out + 4 * width, 16 * width));
        a.q[3 * width + 5] = 1.0f;
        a.k[(size_t)key * width + 30] = NAN; // all queries of head 1
        CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
        for (size_t r = 0; r < 20; r++) CHECK(none_nan(a.out + r * width, 24) && all_nan(a.out + r * width + 24, 24));
        a.k[(size_t)key * width + 30] = 1.0f;
        a.v[(size_t)key * width + 7] = NAN; // column 7
        CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
        for (size_t r = 0; r < 20; r++)
            for (size_t i = 0; i < width; i++) CHECK((a.out[r * width + i] != a.out[r * width + i]) == (i == 7));
        a.v[(size_t)key * width + 7] = 1.0f;
        for (size_t i = 0; i < 24; i++) { // infinite logits of query 0
            a.q[i] = 1e30f;
            a.k[(size_t)key * width + i] = 1e30f;
        }
        CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
        CHECK(all_nan(a.out, 24) && none_nan(a.out + width + 24, 24));
        for (size_t i = 0; i < 24; i++) a.k[(size_t)key * width + i] = -1e30f; // a logit of -inf, weight 0
        CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
        CHECK(none_nan(a.out, 20 * width));
        free_attention(&a);
    }
}

// A bias of -inf hides a key as the mask does; a query with all keys hidden gives 0.
static void check_attention_bias(void) {
    const attention_case c = {20, 300, 2, 24, 0, 0, 0, 1, 1};
    const size_t width = 48;
    attention_data a = make_attention(&c);
    for (size_t j = 0; j < 300; j++) {
        a.bias[j] = -INFINITY;                              // query 0 of head 0
        a.bias[(20 + 7) * 300 + j] = j == 299 ? -5e3f : -INFINITY; // query 7 of head 1
    }
    CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
    for (size_t i = 0; i < 24; i++) {
        CHECK(a.out[i] == 0.0f);
        CHECK_NEAR(a.out[7 * width + 24 + i], a.v[299 * width + 24 + i], 1e-6);
    }
    a.bias[3 * 300 + 299] = NAN;
    CHECK_OK(&one, gsf__nn_run_attention(&one, NULL, &a.desc));
    CHECK(all_nan(a.out + 3 * width, 24) && none_nan(a.out + 3 * width + 24, 16 * width));
    free_attention(&a);
}

static void check_attention_errors(void) {
    const attention_case c = {20, 30, 2, 8, 0, 0, 0, 1, 0};
    attention_data a = make_attention(&c);
    counter memory;
    memset(&memory, 0, sizeof memory);
    gsf_context ctx = three;
    count_memory(&ctx, &memory);
    gsf__nn_workspace workspace;
    memset(&workspace, 0, sizeof workspace);
    memory.fail_at = 1;
    CHECK_RESULT(&ctx, gsf__nn_run_attention(&ctx, NULL, &a.desc), GSF_ERROR_OUT_OF_MEMORY);
    memory.calls = 0;
    CHECK_RESULT(&ctx, gsf__nn_run_attention(&ctx, &workspace, &a.desc), GSF_ERROR_OUT_OF_MEMORY);
    CHECK(memory.live == 0);
    memory.fail_at = 0;
    CHECK_OK(&ctx, gsf__nn_run_attention(&ctx, &workspace, &a.desc));
    memory.calls = 0;
    CHECK_OK(&ctx, gsf__nn_run_attention(&ctx, &workspace, &a.desc)); // allocates nothing more
    CHECK(memory.calls == 0 && memory.live == 1);
    gsf__nn_destroy_workspace(&ctx, &workspace);
    CHECK_OK(&ctx, gsf__nn_run_attention(&ctx, NULL, &a.desc));
    CHECK(memory.live == 0);
    gsf__nn_attention_desc d = a.desc;
    d.queries = 0;
    CHECK_OK(&ctx, gsf__nn_run_attention(&ctx, NULL, &d));
    d = a.desc;
    d.k = NULL;
    CHECK_RESULT(&ctx, gsf__nn_run_attention(&ctx, NULL, &d), GSF_ERROR_INVALID_ARGUMENT);
    d = a.desc;
    d.keys = 0;
    CHECK_RESULT(&ctx, gsf__nn_run_attention(&ctx, NULL, &d), GSF_ERROR_INVALID_ARGUMENT);
    d = a.desc;
    d.head_dim = -1;
    CHECK_RESULT(&ctx, gsf__nn_run_attention(&ctx, NULL, &d), GSF_ERROR_INVALID_ARGUMENT);
    free_attention(&a);
}

int main(void) {
    for (int level = GSF_CPU_SCALAR; level <= GSF_CPU_AMX; level++) {
        if (!open_contexts((gsf_cpu_level)level)) continue;
#if GSF__X86
        if (level >= GSF_CPU_AVX2) check_exp();
#endif
        check_activate();
        check_gelu();
        check_softmax();
        check_row_norms();
        check_group_norm();
        check_streams();
        check_head_norm_rope();
        check_attention();
    check_attention_offset();
        check_attention_values(0);
        check_attention_values(1);
        check_attention_bias();
        check_attention_errors();
    }
    return test_report();
}
