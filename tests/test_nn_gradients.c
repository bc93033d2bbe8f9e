// Gradients of layers over heads, tables and images against central differences of the layers in double: head norm with
// rotary embedding, gates, embeddings, group norm, convolutions (also depthwise), resampling, warping, pixel shuffle, blends.
// Odd sizes, all instruction sets, bit-identical for any number of workers. Prints the worst relative L2 error of each.
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

static uint64_t seed = 1;

// A layer of `params` parameters and inputs, one after another, and `outs` results; the loss is the sum of results * dy.
typedef struct layer {
    const char* name;
    void (*forward)(const struct layer* l, const double* p, double* y);
    gsf_result (*backward)(gsf_context* ctx, const struct layer* l, const float* p, const float* dy, float* grad);
    int64_t params, outs, size[8];
    int option;
    float *cos, *sin;
    int32_t* ids;
} layer;

static double worst_of(const char* name, double error) { // remembers the worst error by name; NULL: prints them
    static struct { const char* name; double error; } all[32];
    size_t i = 0;
    for (; i < 32 && all[i].name && (!name || strcmp(all[i].name, name) != 0); i++)
        if (!name) printf("%-22s worst relative L2 error %.2e\n", all[i].name, all[i].error);
    if (!name || i == 32) return 0.0;
    all[i].name = name;
    if (error > all[i].error) all[i].error = error;
    return error;
}

static double loss(const layer* l, const double* p, const float* dy, double* y) {
    double total = 0.0;
    for (int64_t i = 0; i < l->outs; i++) y[i] = 0.0;
    l->forward(l, p, y);
    for (int64_t i = 0; i < l->outs; i++) total += y[i] * (double)dy[i];
    return total;
}

// All gradients, or if there are many every few of them. The layers are polynomials or smooth, so large steps do.
static void check(gsf_context* ctx, const layer* l) {
    const size_t count = (size_t)l->params, outs = (size_t)l->outs;
    const int64_t stride = l->params / 250 + 1;
    float* values = (float*)malloc((3 * count + outs) * sizeof(float));
    float *grad[2] = {values + count, values + 2 * count}, *dy = values + 3 * count;
    double *p = (double*)malloc((count + outs) * sizeof(double)), *y = p + count, error = 0.0, scale = 0.0;
    gsf_context others;
    memset(&others, 0, sizeof others);
    others.cpu_level = ctx->cpu_level;
    work_backwards(&others);
    CHECK_OK(&others, gsf_init_context(&others));
    for (size_t i = 0; i < count; i++) p[i] = (double)(values[i] = (float)test_random_in(&seed, -1.5, 1.5));
    for (size_t i = 0; i < outs; i++) dy[i] = (float)test_random_in(&seed, -1.0, 1.0);
    for (int k = 0; k < 2; k++) {
        memset(grad[k], 0, count * sizeof(float));
        CHECK_OK(k ? &others : ctx, l->backward(k ? &others : ctx, l, values, dy, grad[k]));
    }
    CHECK(memcmp(grad[0], grad[1], count * sizeof(float)) == 0);
    for (int64_t i = 0; i < l->params; i += stride) {
        const double before = p[i], h = 1e-4;
        p[i] = before + h;
        const double above = loss(l, p, dy, y);
        p[i] = before - h;
        const double slope = (above - loss(l, p, dy, y)) / (2.0 * h);
        p[i] = before;
        scale += slope * slope;
        error += (slope - (double)grad[0][i]) * (slope - (double)grad[0][i]);
    }
    if (!CHECK_NEAR(worst_of(l->name, sqrt(error / (scale > 0.0 ? scale : 1.0))), 0.0, 1e-5))
        fprintf(stderr, "%s: sizes %d %d %d %d %d %d, option %d\n", l->name, (int)l->size[0], (int)l->size[1],
                (int)l->size[2], (int)l->size[3], (int)l->size[4], (int)l->size[5], l->option);
    free(values);
    free(p);
}

// ---- heads: size: rows, heads, head_dim, rope_first. p: x | weight | bias

static void head_forward(const layer* l, const double* p, double* y) {
    const int64_t rows = l->size[0], heads = l->size[1], dim = l->size[2];
    const double *weight = p + rows * heads * dim, *bias = weight + dim;
    for (int64_t n = 0; n < rows * heads; n++) {
        const double* x = p + n * dim;
        double *to = y + n * dim, mean = 0.0, square = 0.0;
        const int64_t turn = n / heads - l->size[3];
        for (int64_t i = 0; i < dim; i++) mean += x[i] / (double)dim;
        for (int64_t i = 0; i < dim; i++) square += (x[i] - mean) * (x[i] - mean) / (double)dim;
        for (int64_t i = 0; i < dim; i++) to[i] = (x[i] - mean) / sqrt(square + (double)1e-5f) * weight[i] + bias[i];
        for (int64_t i = 0; turn >= 0 && l->option && i + 1 < dim; i += 2) {
            const double a = to[i], b = to[i + 1], c = (double)l->cos[turn * dim + i], s = (double)l->sin[turn * dim + i];
            to[i] = a * c - b * s;
            to[i + 1] = b * c + a * s;
        }
    }
}

static gsf_result head_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    const int64_t rows = l->size[0], width = l->size[1] * l->size[2], dim = l->size[2];
    const gsf__nn_head_grad_desc d = {
        p, rows, l->size[3], (int32_t)l->size[1], (int32_t)dim, p + rows * width, l->option ? l->cos : NULL,
        l->option ? l->sin : NULL, 1e-5f, dy, grad, grad + rows * width, grad + rows * width + dim};
    return gsf__nn_head_grad(ctx, &d);
}

static void test_heads(gsf_context* ctx) {
    static const int64_t sizes[][4] = {{1, 1, 2, 0}, {5, 3, 8, 2}, {9, 2, 17, 0}, {70, 2, 16, 3}, {4, 1, 64, 9}};
    for (size_t i = 0; i < 2 * GSF__COUNT(sizes); i++) {
        layer l = {"head norm and rope", head_forward, head_backward, 0, 0, {0}, (int)(i % 2), NULL, NULL, NULL};
        memcpy(l.size, sizes[i / 2], sizeof sizes[0]);
        const int64_t dim = l.size[2], table = l.size[0] * dim;
        l.outs = l.size[0] * l.size[1] * dim;
        l.params = l.outs + 2 * dim;
        l.cos = (float*)malloc((size_t)(2 * table) * sizeof(float));
        l.sin = l.cos + table;
        for (int64_t k = 0; k < table; k++) { // pairs share an angle
            const double angle = 0.37 * (double)((k % dim / 2 + 1) * (k / dim + 1));
            l.cos[k] = (float)cos(angle);
            l.sin[k] = (float)sin(angle);
        }
        check(ctx, &l);
        free(l.cos);
    }
}

// ---- gates: size: rows, columns. p: x | gate. Embeddings: size: rows, dim, table rows. p: table

static void gate_forward(const layer* l, const double* p, double* y) {
    const double* gate = p + l->outs;
    for (int64_t i = 0; i < l->outs; i++) y[i] = gate[i % l->size[1]] * p[i];
}

static gsf_result gate_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    return gsf__nn_gate_grad(ctx, p + l->outs, p, dy, l->size[0], l->size[1], grad, grad + l->outs);
}

static void embed_forward(const layer* l, const double* p, double* y) {
    for (int64_t i = 0; i < l->outs; i++) y[i] = p[l->ids[i / l->size[1]] * l->size[1] + i % l->size[1]];
}

static gsf_result embed_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    (void)p;
    gsf__nn_embed_grad(ctx, l->ids, dy, l->size[0], l->size[1], grad);
    return GSF_OK;
}

static void test_gates_and_tables(gsf_context* ctx) {
    static const int64_t sizes[][2] = {{1, 1}, {7, 19}, {3, 130}, {301, 16}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
        const int64_t rows = sizes[i][0], columns = sizes[i][1], table = 5;
        layer gate = {"gate", gate_forward, gate_backward, (rows + 1) * columns, rows * columns, {rows, columns}, 0, NULL,
                      NULL, NULL};
        check(ctx, &gate);
        layer embed = {"embedding", embed_forward, embed_backward, table * columns, rows * columns, {rows, columns}, 0, NULL,
                       NULL, NULL};
        embed.ids = (int32_t*)malloc((size_t)rows * sizeof(int32_t));
        for (int64_t r = 0; r < rows; r++) embed.ids[r] = (int32_t)(test_random_bits(&seed) % (uint64_t)table);
        check(ctx, &embed);
        free(embed.ids);
    }
}

// ---- group norm: size: channels, count, groups. p: x | weight | bias

static void group_forward(const layer* l, const double* p, double* y) {
    const int64_t n = l->size[1], size = l->outs / l->size[2];
    const double *weight = p + l->outs, *bias = weight + l->size[0];
    for (int64_t g = 0; g < l->size[2]; g++) {
        double mean = 0.0, square = 0.0;
        for (int64_t i = g * size; i < (g + 1) * size; i++) mean += p[i] / (double)size;
        for (int64_t i = g * size; i < (g + 1) * size; i++) square += (p[i] - mean) * (p[i] - mean) / (double)size;
        for (int64_t i = g * size; i < (g + 1) * size; i++)
            y[i] = (p[i] - mean) / sqrt(square + (double)1e-5f) * weight[i / n] + bias[i / n];
    }
}

static gsf_result group_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    gsf__nn_group_norm_grad(ctx, p, dy, l->size[0], l->size[1], l->size[2], p + l->outs, 1e-5f, grad, grad + l->outs,
                            grad + l->outs + l->size[0]);
    return GSF_OK;
}

static void test_group_norm(gsf_context* ctx) {
    static const int64_t sizes[][3] = {{2, 1, 1}, {6, 7, 3}, {4, 33, 1}, {8, 130, 8}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
        layer l = {"group norm", group_forward, group_backward, 0, 0, {0}, 0, NULL, NULL, NULL};
        memcpy(l.size, sizes[i], sizeof sizes[0]);
        l.outs = l.size[0] * l.size[1];
        l.params = l.outs + 2 * l.size[0];
        check(ctx, &l);
    }
}

// ---- convolution: size: frames, height, width, in, out, kernel, kt; option: 1 halve, 2 frames before x.
// p: weight | bias | x | before

static void conv_forward(const layer* l, const double* p, double* y) {
    const int64_t h = l->size[1], w = l->size[2], in = l->size[3], out = l->size[4], k = l->size[5], kt = l->size[6];
    const int64_t halve = l->option & 1, stride = halve ? 2 : 1, oh = h / stride, ow = w / stride, pad = halve ? 0 : k / 2;
    const double *bias = p + out * in * kt * k * k, *x = bias + out, *before = x + l->size[0] * h * w * in;
    for (int64_t i = 0; i < l->outs; i++) {
        const int64_t o = i % out, px = i / out % ow, py = i / out / ow % oh, t = i / out / ow / oh;
        double sum = bias[o];
        for (int64_t a = 0; a < kt * k * k; a++) {
            const int64_t sx = px * stride + a % k - pad, sy = py * stride + a / k % k - pad, st = t + a / (k * k) - kt + 1;
            const double* frame = st >= 0 ? x + st * h * w * in : l->option & 2 ? before + (st + 2) * h * w * in : x;
            if (sx < 0 || sx >= w || sy < 0 || sy >= h) continue;
            for (int64_t c = 0; c < in; c++) sum += p[(o * in + c) * kt * k * k + a] * frame[(sy * w + sx) * in + c];
        }
        y[i] = sum;
    }
}

static gsf_result conv_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    const int64_t* s = l->size;
    const int64_t out = s[4], in = s[3], shape3[5] = {out, in, s[6], s[5], s[5]}, shape2[4] = {out, in, s[5], s[5]};
    const int64_t at_bias = out * in * s[6] * s[5] * s[5], at_x = at_bias + out, at_before = at_x + s[0] * s[1] * s[2] * in;
    const gsf_nn_tensor weight = gsf_nn_wrap_tensor("weight", p, s[6] > 1 ? 5 : 4, s[6] > 1 ? shape3 : shape2);
    gsf__nn_conv_desc f;
    gsf__nn_conv_grad_desc d;
    memset(&f, 0, sizeof f);
    f.x = p + at_x;
    f.frames = s[0];
    f.height = s[1];
    f.width = s[2];
    f.weight = &weight;
    f.before = l->option & 2 ? p + at_before : NULL;
    f.halve = l->option & 1;
    memset(&d, 0, sizeof d);
    d.forward = &f;
    d.dy = dy;
    d.dx = grad + at_x;
    d.dbefore = l->option & 2 ? grad + at_before : NULL;
    d.dweight = grad;
    d.dbias = grad + at_bias;
    GSF__TRY(gsf__nn_conv_grad(ctx, &d));
    d.dweight = d.dbias = NULL; // twice the gradient of x, then half of it
    d.accumulate = 1;
    GSF__TRY(gsf__nn_conv_grad(ctx, &d));
    for (int64_t i = 0; i < s[0] * s[1] * s[2] * in; i++) grad[at_x + i] *= 0.5f;
    return GSF_OK;
}

static void test_convolution(gsf_context* ctx) {
    static const int64_t sizes[][8] = {
        {1, 1, 1, 1, 1, 1, 1, 0},  {1, 5, 4, 3, 2, 3, 1, 0},  {2, 3, 7, 5, 17, 3, 1, 0}, {1, 9, 33, 2, 3, 3, 1, 0},
        {2, 4, 3, 50, 4, 1, 1, 0}, {1, 2, 2, 3, 4, 3, 1, 1},  {2, 6, 9, 4, 3, 3, 1, 1},  {1, 7, 8, 2, 19, 3, 1, 1},
        {1, 3, 4, 2, 3, 3, 3, 0},  {4, 3, 5, 3, 2, 3, 3, 0},  {5, 2, 3, 2, 2, 3, 3, 2},  {1, 2, 2, 2, 2, 3, 3, 2},
        {3, 2, 2, 3, 2, 1, 3, 2},  {2, 1, 1, 4, 33, 3, 1, 0},
        // by Winograd's
        {1, 1, 1, 16, 16, 3, 1, 0}, {3, 5, 7, 16, 17, 3, 1, 0}, {2, 4, 6, 24, 16, 3, 1, 0}, {2, 17, 15, 18, 16, 3, 1, 0},
        {1, 3, 2, 16, 48, 3, 1, 0}, {2, 4, 6, 16, 16, 3, 1, 1}, {3, 3, 4, 17, 16, 3, 3, 0}, {2, 3, 3, 16, 16, 3, 3, 2},
    };
    for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
        layer l = {"convolution", conv_forward, conv_backward, 0, 0, {0}, (int)sizes[i][7], NULL, NULL, NULL};
        memcpy(l.size, sizes[i], sizeof sizes[0]);
        const int64_t* s = l.size;
        const int64_t stride = l.option & 1 ? 2 : 1, plane = s[1] * s[2] * s[3];
        l.outs = s[0] * (s[1] / stride) * (s[2] / stride) * s[4];
        l.params = s[4] * s[3] * s[6] * s[5] * s[5] + s[4] + s[0] * plane + (l.option & 2 ? 2 * plane : 0);
        check(ctx, &l);
    }
}

// ---- depthwise: size: frames, height, width, channels, kernel. p: weight | bias | x. Forward results are compared, too.

static void depthwise_forward(const layer* l, const double* p, double* y) {
    const int64_t h = l->size[1], w = l->size[2], c = l->size[3], k = l->size[4];
    const double *bias = p + c * k * k, *x = bias + c;
    for (int64_t i = 0; i < l->outs; i++) {
        const int64_t channel = i % c, px = i / c % w, py = i / c / w % h, frame = i / c / w / h;
        double sum = bias[channel];
        for (int64_t t = 0; t < k * k; t++) {
            const int64_t sx = px + t % k - k / 2, sy = py + t / k - k / 2;
            if (sx < 0 || sx >= w || sy < 0 || sy >= h) continue;
            sum += p[channel * k * k + t] * x[((frame * h + sy) * w + sx) * c + channel];
        }
        y[i] = sum;
    }
}

static gsf_result depthwise_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    const int64_t *s = l->size, bias = s[3] * s[4] * s[4], x = bias + s[3];
    float* y = (float*)malloc((size_t)l->outs * sizeof(float));
    double* wide = (double*)malloc((size_t)(l->outs + l->params) * sizeof(double));
    const gsf__nn_depthwise d = {p + x, s[0], s[1], s[2], s[3], s[4], p, p + bias, y, dy, grad + x, grad, grad + bias};
    GSF__TRY(gsf__nn_depthwise_forward(ctx, &d));
    for (int64_t i = 0; i < l->params; i++) wide[l->outs + i] = (double)p[i];
    depthwise_forward(l, wide + l->outs, wide);
    test_compare_floats("depthwise", y, wide, (size_t)l->outs, 1e-5);
    free(y);
    free(wide);
    return gsf__nn_depthwise_backward(ctx, &d);
}

static void test_depthwise(gsf_context* ctx) {
    static const int64_t sizes[][5] = {{1, 1, 1, 1, 1}, {1, 2, 3, 5, 3}, {2, 7, 40, 3, 3}, {1, 5, 6, 17, 5}, {3, 4, 2, 9, 7}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
        layer l = {"depthwise convolution", depthwise_forward, depthwise_backward, 0, 0, {0}, 0, NULL, NULL, NULL};
        memcpy(l.size, sizes[i], sizeof sizes[0]);
        const int64_t* s = l.size;
        l.outs = s[0] * s[1] * s[2] * s[3];
        l.params = l.outs + s[3] * (s[4] * s[4] + 1);
        check(ctx, &l);
    }
}

// ---- resampling: size: height, width, new height, new width, channels. option 0: nearest, 1: bilinear, 2: warp by
// `cos`. p: x. Forward results are compared, too.

static double pixel(const layer* l, const double* p, double x, double y, int64_t c, int zeros) { // bilinear
    const int64_t h = l->size[0], w = l->size[1], channels = l->size[4];
    const double left = floor(x), top = floor(y);
    double sum = 0.0;
    for (int i = 0; i < 4; i++) {
        double px = left + i % 2, py = top + i / 2;
        const double weight = (i % 2 ? x - left : 1.0 - x + left) * (i / 2 ? y - top : 1.0 - y + top);
        if (zeros && (px < 0 || py < 0 || px >= (double)w || py >= (double)h)) continue;
        px = fmin(fmax(px, 0.0), (double)(w - 1));
        py = fmin(fmax(py, 0.0), (double)(h - 1));
        sum += weight * p[((int64_t)py * w + (int64_t)px) * channels + c];
    }
    return sum;
}

static void resample_forward(const layer* l, const double* p, double* y) {
    const int64_t h = l->size[0], w = l->size[1], nh = l->size[2], nw = l->size[3], channels = l->size[4];
    for (int64_t i = 0; i < l->outs; i++) {
        const int64_t to = i / channels, ty = to / nw, tx = to % nw, c = i % channels;
        if (l->option == 0) y[i] = p[(ty * h / nh * w + tx * w / nw) * channels + c];
        else if (l->option == 2) {
            const double x = (double)l->cos[2 * to], v = (double)l->cos[2 * to + 1];
            y[i] = fabs(x) < 1e6 && fabs(v) < 1e6 ? pixel(l, p, x, v, c, 1) : 0.0;
        } else y[i] = pixel(l, p, fmax(((double)tx + 0.5) * (double)w / (double)nw - 0.5, 0.0),
                            fmax(((double)ty + 0.5) * (double)h / (double)nh - 0.5, 0.0), c, 0);
    }
}

static gsf_result resample_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    const gsf__nn_grid from = {l->size[0], l->size[1]}, to = {l->size[2], l->size[3]};
    gsf__nn_taps taps;
    if (l->option == 2) GSF__TRY(gsf__nn_make_warp(ctx, from, to, l->cos, &taps));
    else GSF__TRY(gsf__nn_make_resize(ctx, from, to, l->option, &taps));
    float* y = (float*)malloc((size_t)l->outs * sizeof(float));
    double* wide = (double*)malloc((size_t)(l->outs + l->params) * sizeof(double));
    gsf__nn_gather(ctx, &taps.forward, p, l->size[4], 0, y);
    for (int64_t i = 0; i < l->params; i++) wide[l->outs + i] = (double)p[i];
    resample_forward(l, wide + l->outs, wide);
    test_compare_floats(l->name, y, wide, (size_t)l->outs, 2e-5);
    gsf__nn_gather(ctx, &taps.backward, dy, l->size[4], 1, grad); // added to zeros
    gsf__nn_destroy_taps(ctx, &taps);
    free(y);
    free(wide);
    return GSF_OK;
}

static void test_resampling(gsf_context* ctx) {
    static const int64_t sizes[][5] = {{1, 1, 3, 2, 1}, {3, 5, 6, 10, 9}, {7, 4, 5, 9, 17}, {8, 9, 4, 3, 3}, {5, 6, 5, 6, 8}};
    static const char* const names[] = {"nearest", "bilinear", "warp"};
    for (size_t i = 0; i < 3 * GSF__COUNT(sizes); i++) {
        layer l = {names[i % 3], resample_forward, resample_backward, 0, 0, {0}, (int)(i % 3), NULL, NULL, NULL};
        memcpy(l.size, sizes[i / 3], sizeof sizes[0]);
        l.params = l.size[0] * l.size[1] * l.size[4];
        l.outs = l.size[2] * l.size[3] * l.size[4];
        const int64_t positions = 2 * l.size[2] * l.size[3];
        l.cos = (float*)malloc((size_t)positions * sizeof(float));
        for (int64_t k = 0; k < positions; k++) // also outside of the image, and on pixels
            l.cos[k] = (float)test_random_in(&seed, -2.5, (double)l.size[k % 2 ? 0 : 1] + 1.5);
        l.cos[0] = 0.0f;
        l.cos[positions - 1] = NAN;
        check(ctx, &l);
        free(l.cos);
    }
}

// ---- pixel shuffle: size: rows, width, channels, factor. p: x

static void shuffle_forward(const layer* l, const double* p, double* y) { // y[c][f y + i][f x + j] = x[(c f + i) f + j][y][x]
    const int64_t rows = l->size[0], w = l->size[1], channels = l->size[2], f = l->size[3];
    for (int64_t r = 0; r < rows * f; r++)
        for (int64_t x = 0; x < w * f; x++)
            for (int64_t c = 0; c < channels; c++)
                y[(r * w * f + x) * channels + c] = p[(r / f * w + x / f) * channels * f * f + (c * f + r % f) * f + x % f];
}

static gsf_result shuffle_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    const int64_t* s = l->size;
    float* again = (float*)malloc((size_t)(2 * l->params) * sizeof(float));
    gsf__nn_shuffle_pixels(ctx, p, s[0], s[1], s[2], s[3], 0, again);
    gsf__nn_shuffle_pixels(ctx, again, s[0], s[1], s[2], s[3], 1, again + l->params);
    CHECK(memcmp(again + l->params, p, (size_t)l->params * sizeof(float)) == 0);
    free(again);
    gsf__nn_shuffle_pixels(ctx, dy, s[0], s[1], s[2], s[3], 1, grad);
    return GSF_OK;
}

// ---- blends: size: pixels, candidates, channels. p: logits | x

static void blend_forward(const layer* l, const double* p, double* y) {
    const int64_t n = l->size[1], c = l->size[2];
    const double* x = p + l->size[0] * n;
    for (int64_t i = 0; i < l->outs; i++) {
        double sum = 0.0, total = 0.0;
        for (int64_t k = 0; k < n; k++) {
            const double weight = exp(p[i / c * n + k]);
            sum += weight;
            total += weight * x[(i / c * n + k) * c + i % c];
        }
        y[i] = total / sum;
    }
}

static gsf_result blend_backward(gsf_context* ctx, const layer* l, const float* p, const float* dy, float* grad) {
    const int64_t logits = l->size[0] * l->size[1];
    float *weights = (float*)malloc((size_t)logits * sizeof(float)), *y = (float*)malloc((size_t)l->outs * sizeof(float));
    double* wide = (double*)malloc((size_t)(l->outs + l->params) * sizeof(double));
    gsf__nn_blend b = {l->size[0], l->size[1], l->size[2], p + logits, weights, y, dy, grad + logits, grad};
    gsf__nn_softmax(ctx, p, l->size[0], l->size[1], 1.0f, weights);
    gsf__nn_blend_forward(ctx, &b);
    for (int64_t i = 0; i < l->params; i++) wide[l->outs + i] = (double)p[i];
    blend_forward(l, wide + l->outs, wide);
    test_compare_floats("blend", y, wide, (size_t)l->outs, 2e-6);
    gsf__nn_blend_backward(ctx, &b);
    free(weights);
    free(y);
    free(wide);
    return GSF_OK;
}

static void test_blends(gsf_context* ctx) {
    static const int64_t sizes[][4] = {{1, 1, 1, 1}, {3, 5, 2, 2}, {7, 8, 3, 3}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++) {
        const int64_t *s = sizes[i], count = s[0] * s[1] * s[2] * s[3] * s[3];
        layer shuffle = {"pixel shuffle", shuffle_forward, shuffle_backward, count, count, {s[0], s[1], s[2], s[3]}, 0, NULL,
                         NULL, NULL};
        check(ctx, &shuffle);
        layer blend = {"blend", blend_forward, blend_backward, s[0] * s[1] * (s[2] + 1), s[0] * s[2], {s[0], s[1], s[2]}, 0,
                       NULL, NULL, NULL};
        check(ctx, &blend);
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
        test_heads(&ctx);
        test_gates_and_tables(&ctx);
        test_group_norm(&ctx);
        test_convolution(&ctx);
        test_depthwise(&ctx);
        test_resampling(&ctx);
        test_blends(&ctx);
    }
    worst_of(NULL, 0.0);
    return test_report();
}
