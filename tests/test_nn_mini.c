// The network of the restorer mini: its results and gradients against the same network in double and central differences, for
// all instruction sets and orders of work; nearly the identity at the start; any order of references; files that are none,
// bytes instead of a file; failing allocations; the restorer's checks.
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

enum { BATCH = 2, REFERENCES = 2, WIDTH = 32, HEIGHT = 16, PIXELS = WIDTH * HEIGHT, CANDIDATES = 2 + 3 * REFERENCES };
enum { FRAME_VALUES = PIXELS * GSF__MINI_FRAME, SHOWN_VALUES = REFERENCES * PIXELS * GSF__MINI_REFERENCE };

static uint64_t mini_seed = 1;

// ---- the network in double -------------------------------------------------------

typedef struct twin { const gsf__mini* net; const gsf__nn_params* params; const double* values; } twin; // values: of params

static const double* value_of(const twin* t, const gsf_nn_tensor* tensor) {
    return t->values + t->params->at[tensor - t->params->weights->tensors];
}

// y = (or +=) the convolution of one image; channels last.
static void convolve(const twin* t, const gsf__nn_layer* l, const double* x, int h, int w, int halve, int add, double* y) {
    const int out = (int)l->weight->shape[0], in = (int)l->weight->shape[1], k = (int)l->weight->shape[2];
    const double *weight = value_of(t, l->weight), *bias = l->bias ? value_of(t, l->bias) : NULL;
    const int oh = halve ? h / 2 : h, ow = halve ? w / 2 : w, step = halve ? 2 : 1, pad = halve ? 0 : k / 2;
    for (int p = 0; p < oh * ow * out; p++) {
        const int o = p % out, cx = p / out % ow * step - pad, cy = p / out / ow * step - pad;
        double sum = bias ? bias[o] : 0.0;
        for (int i = 0; i < k * k; i++) {
            const int sx = cx + i % k, sy = cy + i / k;
            if (sx < 0 || sy < 0 || sx >= w || sy >= h) continue;
            for (int c = 0; c < in; c++) sum += weight[(o * in + c) * k * k + i] * x[(sy * w + sx) * in + c];
        }
        y[p] = add ? y[p] + sum : sum;
    }
}

static double* doubles(int count) { return (double*)calloc((size_t)count, sizeof(double)); }
static void relu(double* x, int count) {
    for (int i = 0; i < count; i++) x[i] = x[i] > 0.0 ? x[i] : 0.0;
}

static void block(const twin* t, const gsf__mini_block* b, int h, int w, int c, double* x) {
    double *a = doubles(h * w * c), *m = doubles(h * w * c);
    memcpy(a, x, (size_t)(h * w * c) * sizeof *a);
    relu(a, h * w * c);
    convolve(t, &b->first, a, h, w, 0, 0, m);
    relu(m, h * w * c);
    convolve(t, &b->second, m, h, w, 0, 1, x);
    free(a), free(m);
}

// A level and those below it: x is its input, of the size of the level above (the first: its own); returns y.
static double* level(const twin* t, int l, const double* x, int h, int w) {
    const gsf__mini_level* n = &t->net->levels[l];
    const int c = (int)t->net->width[l], lh = l ? h / 2 : h, lw = l ? w / 2 : w, size = lh * lw * c;
    double* down = doubles(size);
    convolve(t, &n->down, x, h, w, l > 0, 0, down);
    for (int k = 0; k < t->net->blocks[l]; k++) block(t, &n->in[k], lh, lw, c, down);
    relu(down, size);
    if (l + 1 == GSF__MINI_LEVELS) return down;
    double *low = level(t, l + 1, down, lh, lw), *y = doubles(size), *little = doubles(size);
    convolve(t, &n->skip, down, lh, lw, 0, 0, y);
    convolve(t, &n->below, low, lh / 2, lw / 2, 0, 0, little);
    for (int i = 0; i < size; i++) y[i] += little[((i / c / lw / 2) * (lw / 2) + i / c % lw / 2) * c + i % c];
    block(t, &n->out, lh, lw, c, y);
    relu(y, size);
    free(down), free(low), free(little);
    return y;
}

// out (height, width, 3), error (height, width, 2: of the result, of the render) of one frame
static void run_twin(const twin* t, const gsf__mini_input* in, double* out, double* error) {
    enum { H = HEIGHT / 2, W = WIDTH / 2, COARSE = H * W };
    const int e = (int)t->net->features, hidden = (int)t->net->hidden, s = (int)t->net->shared, pitch = 20 + 2 * e;
    double *frame = doubles(COARSE * pitch), *features = doubles(REFERENCES * COARSE * e), *head = doubles(COARSE * 28);
    double *choices = doubles(REFERENCES * COARSE * 12), *shown = doubles(REFERENCES * COARSE * 56);
    double* common = doubles(COARSE * s);
    double *attention = doubles(REFERENCES * COARSE), *first = doubles(COARSE * hidden), *heads = doubles(COARSE * s);
    for (int i = 0; i < PIXELS; i++) {
        const int x = i % WIDTH, y = i / WIDTH, at = (y / 2 * W + x / 2), part = y % 2 * 2 + x % 2;
        const float* f = in->frame + i * 5;
        for (int c = 0; c < 5; c++) frame[at * pitch + part * 5 + c] = (double)f[c] - (c < 3 ? 0.5 : 0.0);
        for (int k = 0; k < REFERENCES; k++) {
            const float* p = in->shown + (k * PIXELS + i) * 14;
            double* o = shown + ((k * COARSE + at) * 4 + part) * 14;
            const double seen = p[6] > 0.0f, valid = p[12] > 0.0f;
            for (int c = 0; c < 3; c++) {
                o[c] = 2.0 * seen * ((double)p[c] - (double)f[c]);
                o[3 + c] = 4.0 * seen * (double)p[3 + c];
                o[9 + c] = 2.0 * valid * ((double)p[9 + c] - (double)f[c]);
            }
            o[6] = (double)p[6];
            o[7] = seen * (double)p[7];
            o[8] = seen * (double)p[8];
            o[12] = valid;
            o[13] = valid * (double)p[13];
        }
    }
    for (int k = 0; k < REFERENCES; k++) {
        double* f = features + k * COARSE * e;
        convolve(t, &t->net->first, shown + k * COARSE * 56, H, W, 0, 0, first);
        relu(first, COARSE * hidden);
        convolve(t, &t->net->second, first, H, W, 0, 0, f);
        relu(f, COARSE * e);
        convolve(t, &t->net->attention, f, H, W, 0, 0, attention + k * COARSE);
    }
    for (int i = 0; i < COARSE; i++) {
        double sum = 1.0, *mean = frame + i * pitch + 20, *most = mean + e;
        for (int k = 0; k < REFERENCES; k++) {
            int any = 0;
            for (int part = 0; part < 4; part++) {
                const double* o = shown + ((k * COARSE + i) * 4 + part) * 14;
                any |= o[6] > 0.0 || o[12] > 0.0;
            }
            double* a = attention + k * COARSE + i;
            *a = any ? exp(*a) : 0.0;
            sum += *a;
            for (int c = 0; c < e && !any; c++) features[(k * COARSE + i) * e + c] = 0.0;
        }
        for (int k = 0; k < REFERENCES * e; k++) {
            const double f = features[(k / e * COARSE + i) * e + k % e];
            mean[k % e] += 2.0 * attention[k / e * COARSE + i] / sum * f;
            if (f > most[k % e]) most[k % e] = f;
        }
    }
    double* y = level(t, 0, frame, H, W);
    convolve(t, &t->net->head, y, H, W, 0, 0, head);
    convolve(t, &t->net->head_frame, y, H, W, 0, 0, common);
    for (int k = 0; k < REFERENCES; k++) {
        memcpy(heads, common, (size_t)(COARSE * s) * sizeof *heads);
        convolve(t, &t->net->head_reference, features + k * COARSE * e, H, W, 0, 1, heads);
        relu(heads, COARSE * s);
        convolve(t, &t->net->head_blend, heads, H, W, 0, 0, choices + k * COARSE * 12);
    }
    for (int i = 0; i < PIXELS; i++) {
        const int x = i % WIDTH, row = i / WIDTH, at = (row / 2 * W + x / 2) * 4 + row % 2 * 2 + x % 2;
        double weight[CANDIDATES], sum = 0.0, *h = head + at * 7;
        for (int k = 0; k < CANDIDATES; k++) {
            const int r = (k - 2) / 3, c = (k - 2) % 3;
            const double* o = shown + (k < 2 ? 0 : (r * COARSE * 4 + at) * 14);
            weight[k] = k < 2 ? exp(h[k]) : o[c < 2 ? 6 : 12] > 0.0 ? exp(choices[(r * COARSE * 4 + at) * 3 + c]) : 0.0;
            sum += weight[k];
        }
        const double part = (h[6] - log(0.012)) / log(2.0), gate = part > 1.0 ? 1.0 : part > 0.0 ? part : 0.0;
        for (int c = 0; c < 3; c++) {
            double value = weight[1] / sum * 0.5 * h[2 + c];
            for (int k = 2; k < CANDIDATES; k++) {
                const double* o = shown + ((k - 2) / 3 * COARSE * 4 + at) * 14;
                const int kind = (k - 2) % 3;
                value += weight[k] / sum * (kind == 0 ? 0.5 * o[c] : kind == 1 ? 0.25 * o[3 + c] : 0.5 * o[9 + c]);
            }
            out[3 * i + c] = (double)in->frame[i * 5 + c] + gate * value;
        }
        for (int k = 0; k < 2; k++) error[2 * i + k] = h[5 + k] > 0.0 ? 0.0 : h[5 + k] > -6.0 ? h[5 + k] : -6.0;
    }
    free(frame), free(features), free(head), free(choices), free(shown), free(common), free(attention), free(first);
    free(heads), free(y);
}

// ---- inputs ----------------------------------------------------------------------

static float planes[BATCH * (FRAME_VALUES + SHOWN_VALUES)];

static void make_inputs(gsf__mini_input* in, int batch, int width, int height, int references, float* memory) {
    for (int b = 0; b < batch; b++) {
        float *frame = memory, *shown = memory + width * height * GSF__MINI_FRAME;
        for (int i = 0; i < width * height * GSF__MINI_FRAME; i++) frame[i] = (float)test_random(&mini_seed);
        for (int i = 0; i < references * width * height; i++) {
            float* p = shown + i * GSF__MINI_REFERENCE;
            const int seen = i % width > 8, valid = i / width % height < height - 4; // some of both, and neither
            for (int k = 0; k < GSF__MINI_REFERENCE; k++)
                p[k] = (float)test_random_in(&mini_seed, k == 3 || k == 7 ? -1.0 : 0.1, 1.0);
            if (!seen || test_random(&mini_seed) < 0.1) p[6] = 0.0f;
            p[12] = valid && test_random(&mini_seed) < 0.8 ? 1.0f : 0.0f;
        }
        in[b].width = width;
        in[b].height = height;
        in[b].references = references;
        in[b].frame = frame;
        in[b].shown = shown;
        memory = shown + references * width * height * GSF__MINI_REFERENCE;
    }
}

static gsf__mini tiny(void) {
    static const int64_t widths[GSF__MINI_LEVELS] = {4, 3, 5, 2};
    gsf__mini net;
    memset(&net, 0, sizeof net);
    net.hidden = 3;
    net.features = 2;
    net.shared = 3;
    for (int l = 0; l < GSF__MINI_LEVELS; l++) {
        net.width[l] = widths[l];
        net.blocks[l] = 1 + l / 2;
    }
    return net;
}

static const char* made_path(void) {
    static char path[1200];
    snprintf(path, sizeof path, "%s", test_scratch("mini.safetensors"));
    return path;
}

static double difference(const float* a, const double* b, size_t count) { // relative L2
    double error = 0.0, size = 1e-30;
    for (size_t i = 0; i < count; i++) {
        error += ((double)a[i] - b[i]) * ((double)a[i] - b[i]);
        size += b[i] * b[i];
    }
    return sqrt(error / size);
}

// ---- results and gradients -------------------------------------------------------

static void test_gradients(gsf_context* ctx) {
    enum { RESULT = BATCH * PIXELS * 3, MISTAKE = BATCH * PIXELS * 2, EACH = 24 };
    static float dout[RESULT], derror[MISTAKE], errors[MISTAKE];
    static double out[2][RESULT], error[2][MISTAKE];
    gsf__mini net, sizes = tiny();
    gsf__nn_params params;
    gsf__mini_run run;
    gsf__mini_input in[BATCH];
    mini_seed = 10; // no unit and no gate is as near to its kink as the differences step
    make_inputs(in, BATCH, WIDTH, HEIGHT, REFERENCES, planes);
    CHECK_OK(ctx, gsf__mini_make(ctx, &sizes, 1, made_path()));
    if (!CHECK_OK(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &net))) return;
    CHECK_OK(ctx, gsf__nn_make_params(ctx, &net.weights, NULL, 0, &params));
    double* values = (double*)malloc((size_t)params.count * sizeof *values);
    const gsf_nn_tensor* bias = gsf_nn_find_tensor(&net.weights, "head.bias");
    for (int64_t i = 6; i < bias->count; i += GSF__MINI_HEAD) // gates between open and closed, and some of both
        params.value[params.at[bias - net.weights.tensors] + i] = gsf__mini_kept + 0.1f;
    for (int64_t i = 0; i < params.count; i++)
        values[i] = (double)(params.value[i] += (float)test_random_in(&mini_seed, -0.3, 0.3));
    for (int i = 0; i < RESULT; i++) dout[i] = (float)test_random_in(&mini_seed, -1.0, 1.0);
    for (int i = 0; i < MISTAKE; i++) derror[i] = (float)test_random_in(&mini_seed, -1.0, 1.0);
    const twin t = {&net, &params, values};
    for (int b = 0; b < BATCH; b++) run_twin(&t, &in[b], out[0] + 3 * PIXELS * b, error[0] + 2 * PIXELS * b);
    CHECK_OK(ctx, gsf__mini_begin(ctx, &net, BATCH, REFERENCES, WIDTH, HEIGHT, 0, &run)); // results without training
    CHECK_OK(ctx, gsf__mini_forward(&run, in));
    CHECK_NEAR(difference(run.out, out[0], RESULT), 0.0, 1e-6);
    int open = 0, closed = 0;
    for (int64_t i = 0; i < BATCH * PIXELS; i++) open += run.fault[i] >= logf(0.024f), closed += run.fault[i] <= gsf__mini_kept;
    CHECK(open > 50 && closed > 50 && open + closed < BATCH * PIXELS - 50);
    gsf__mini_end(&run);
    float* grad = (float*)malloc((size_t)params.count * sizeof *grad);
    for (int k = 0; k < 2; k++) {
        gsf_context others;
        memset(&others, 0, sizeof others);
        others.cpu_level = ctx->cpu_level;
        if (k) work_backwards(&others);
        CHECK_OK(&others, gsf_init_context(&others));
        CHECK_OK(&others, gsf__mini_begin(&others, &net, BATCH, REFERENCES, WIDTH, HEIGHT, 1, &run));
        CHECK_OK(&others, gsf__mini_forward(&run, in));
        CHECK_NEAR(difference(run.out, out[0], RESULT), 0.0, 1e-6);
        for (int i = 0; i < MISTAKE; i++) errors[i] = i % 2 ? run.fault[i / 2] : run.error[i / 2];
        CHECK_NEAR(difference(errors, error[0], MISTAKE), 0.0, 1e-6);
        memcpy(run.dout, dout, sizeof dout);
        for (int i = 0; i < MISTAKE; i++) *(i % 2 ? run.dfault + i / 2 : run.derror + i / 2) = derror[i];
        memset(params.grad, 0, (size_t)params.count * sizeof *params.grad);
        CHECK_OK(&others, gsf__mini_backward(&run, &params));
        gsf__mini_end(&run);
        if (!k) memcpy(grad, params.grad, (size_t)params.count * sizeof *grad);
        else CHECK(memcmp(grad, params.grad, (size_t)params.count * sizeof *grad) == 0);
    }
    double worst = 0.0;
    for (size_t i = 0; i < net.weights.tensor_count; i++) { // some values of each tensor
        const int64_t count = net.weights.tensors[i].count, stride = count / test_few(EACH, 4) + 1;
        double miss = 0.0, size = 0.0; // mean squares: of the misses of the values that are tried, of the tensor's gradient
        int tried = 0;
        for (int64_t k = 0; k < count; k++) size += (double)grad[params.at[i] + k] * grad[params.at[i] + k] / (double)count;
        for (int64_t k = stride / 2 % count; k < count; k += stride, tried++) {
            double* p = values + params.at[i] + k;
            const double before = *p, step = 1e-6;
            double slope = 0.0;
            for (int side = 0; side < 2; side++) { // differences of results: those of their sums would be less exact
                *p = before + (side ? step : -step);
                for (int b = 0; b < BATCH; b++) run_twin(&t, &in[b], out[side] + 3 * PIXELS * b, error[side] + 2 * PIXELS * b);
            }
            for (int j = 0; j < RESULT; j++) slope += (out[1][j] - out[0][j]) * (double)dout[j] / (2.0 * step);
            for (int j = 0; j < MISTAKE; j++) slope += (error[1][j] - error[0][j]) * (double)derror[j] / (2.0 * step);
            *p = before;
            miss += (slope - (double)grad[params.at[i] + k]) * (slope - (double)grad[params.at[i] + k]);
        }
        const double relative = sqrt(miss / tried / (size + 1e-12));
        if (!CHECK(relative < 1e-5))
            fprintf(stderr, "%s: relative error of the gradient %g\n", net.weights.tensors[i].name, relative);
        if (relative > worst) worst = relative;
    }
    printf("gradients: worst relative L2 error of a tensor %.2e\n", worst);
    free(values);
    free(grad);
    gsf__nn_destroy_params(ctx, &params);
    gsf__mini_close(ctx, &net);
}

// The loss in double, of results given as floats but for one, moved by `step`; `size` is that of the errors before it moved.
static double loss_of(const gsf__mini_run* r, const gsf__mini_input* in, const float* truth, int moved, int at, double step) {
    double total = 0.0;
    for (int b = 0; b < BATCH; b++) {
        double sums[6] = {0};
        for (int i = 0; i < 3 * PIXELS; i++) {
            const int pixel = b * PIXELS + i / 3, x = i / 3 % WIDTH, y = i / 3 / WIDTH;
#define MISS(k) ((double)r->out[k] + (moved == 1 && (k) == at ? step : 0.0) - (double)truth[k])
            const int k = 3 * b * PIXELS + i;
            const double e = MISS(k), render = (double)(in[b].frame[i / 3 * 5 + i % 3] - 0.5f) + 0.5 - (double)truth[k];
            const double log_error = (double)r->error[pixel] + (moved == 2 && pixel == at ? step : 0.0);
            const double fault = (double)r->fault[pixel] + (moved == 3 && pixel == at ? step : 0.0);
            sums[0] += sqrt(e * e + 1e-3);
            sums[1] += e * e;
            sums[2] += render * render;
            sums[3] += (fabs((double)r->out[k] - (double)truth[k]) * exp(-log_error) + log_error) / 3.0;
            if (moved == 1) sums[3] = 0.0; // its slope does not reach the colours
            sums[5] += (fabs(render) * exp(-fault) + fault) / 3.0;
            if (x + 1 < WIDTH) sums[4] += fabs(MISS(k + 3) - e);
            if (y + 1 < HEIGHT) sums[4] += fabs(MISS(k + 3 * WIDTH) - e);
#undef MISS
        }
        const double n = 3.0 * PIXELS;
        total += (sums[1] / n / (sums[2] / n + 2e-3) + 2.0 * sums[0] / n + 0.5 * sums[4] / n +
                  0.02 * (sums[3] + sums[5]) / PIXELS) / BATCH;
    }
    return total;
}

static void test_loss(gsf_context* ctx) {
    static float truth[BATCH * PIXELS * 3];
    gsf__mini net, sizes = tiny();
    gsf__mini_run run;
    gsf__mini_input in[BATCH];
    gsf__mini_loss loss;
    make_inputs(in, BATCH, WIDTH, HEIGHT, REFERENCES, planes);
    for (size_t i = 0; i < GSF__COUNT(truth); i++) truth[i] = (float)test_random(&mini_seed);
    CHECK_OK(ctx, gsf__mini_make(ctx, &sizes, 1, made_path()));
    if (!CHECK_OK(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &net))) return;
    CHECK_OK(ctx, gsf__mini_begin(ctx, &net, BATCH, REFERENCES, WIDTH, HEIGHT, 1, &run));
    CHECK_OK(ctx, gsf__mini_forward(&run, in));
    CHECK_OK(ctx, gsf__mini_measure_loss(&run, truth, &loss));
    CHECK_NEAR(loss.total, loss_of(&run, in, truth, 0, 0, 0.0), 1e-9);
    for (int k = 0; k < 40; k++) {
        const int at = (int)(test_random(&mini_seed) * BATCH * PIXELS * 3), pixel = at / 3;
        const double step = 1e-7;
        const double color = loss_of(&run, in, truth, 1, at, step) - loss_of(&run, in, truth, 1, at, -step);
        const double error = loss_of(&run, in, truth, 2, pixel, step) - loss_of(&run, in, truth, 2, pixel, -step);
        CHECK_NEAR((double)run.dout[at], color / (2.0 * step), 1e-7);
        CHECK_NEAR((double)run.derror[pixel], error / (2.0 * step), 1e-7);
        const double fault = loss_of(&run, in, truth, 3, pixel, step) - loss_of(&run, in, truth, 3, pixel, -step);
        CHECK_NEAR((double)run.dfault[pixel], fault / (2.0 * step), 1e-7);
    }
    gsf__mini_end(&run);
    gsf__mini_close(ctx, &net);
}

// ---- a new network ---------------------------------------------------------------

static void test_start(gsf_context* ctx) {
    enum { W = 37, H = 21, N = W * H * (GSF__MINI_FRAME + 3 * GSF__MINI_REFERENCE) }; // extended to 48 x 32 inside
    static float memory[N];
    gsf__mini net, sizes = tiny();
    gsf__mini_run run;
    gsf__mini_input in;
    make_inputs(&in, 1, W, H, 3, memory);
    CHECK_OK(ctx, gsf__mini_make(ctx, &sizes, 3, made_path()));
    if (!CHECK_OK(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &net))) return;
    CHECK_OK(ctx, gsf__mini_begin(ctx, &net, 1, 3, W, H, 0, &run));
    CHECK(run.width == 48 && run.height == 32);
    CHECK_OK(ctx, gsf__mini_forward(&run, &in));
    double most = 0.0;
    for (int64_t y = 0; y < H; y++)
        for (int64_t x = 0; x < 3 * W; x++) {
            const float before = in.frame[(y * W + x / 3) * GSF__MINI_FRAME + x % 3];
            most = fmax(most, fabs((double)(run.out[y * 3 * run.width + x] - before)));
        }
    CHECK(most < 0.025);
    gsf__mini_end(&run);
    gsf__mini_close(ctx, &net);
}

// A render whose expected error is small stays as it is.
static void test_gate(gsf_context* ctx) {
    static float biases[4 * GSF__MINI_HEAD];
    gsf__mini net, sizes = tiny();
    gsf__mini_run run;
    gsf__mini_input in;
    double most[2] = {0.0, 0.0};
    make_inputs(&in, 1, WIDTH, HEIGHT, REFERENCES, planes);
    for (int closed = 0; closed < 2; closed++) {
        CHECK_OK(ctx, gsf__mini_make(ctx, &sizes, 3, made_path()));
        if (!CHECK_OK(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &net))) return;
        gsf_nn_tensor* tensors = (gsf_nn_tensor*)malloc(net.weights.tensor_count * sizeof *tensors);
        memcpy(tensors, net.weights.tensors, net.weights.tensor_count * sizeof *tensors);
        for (int i = 0; i < 4 * GSF__MINI_HEAD; i++) biases[i] = i % GSF__MINI_HEAD < 6 ? 0.0f : closed ? -4.5f : -3.5f;
        tensors[gsf_nn_find_tensor(&net.weights, "head.bias") - net.weights.tensors].data = biases;
        CHECK_OK(ctx, gsf_nn_save_tensors(ctx, made_path(), tensors, net.weights.tensor_count));
        free(tensors);
        gsf__mini_close(ctx, &net);
        if (!CHECK_OK(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &net))) return;
        CHECK_OK(ctx, gsf__mini_begin(ctx, &net, 1, REFERENCES, WIDTH, HEIGHT, 0, &run));
        CHECK_OK(ctx, gsf__mini_forward(&run, &in));
        for (int i = 0; i < 3 * PIXELS; i++)
            most[closed] = fmax(most[closed], fabs((double)(run.out[i] - in.frame[i / 3 * GSF__MINI_FRAME + i % 3])));
        gsf__mini_end(&run);
        gsf__mini_close(ctx, &net);
    }
    CHECK(most[0] > 0.1);
    CHECK_NEAR(most[1], 0.0, 6e-8);
}

// The same for references in another order, but for rounding.
static void test_order(gsf_context* ctx, const gsf__mini* net) {
    gsf__mini_input in, swapped;
    gsf__mini_run run;
    float* turned = (float*)malloc(SHOWN_VALUES * sizeof(float));
    double* before = (double*)malloc(3 * PIXELS * sizeof(double));
    make_inputs(&in, 1, WIDTH, HEIGHT, REFERENCES, planes);
    for (int k = 0; k < REFERENCES; k++)
        memcpy(turned + k * (SHOWN_VALUES / REFERENCES), in.shown + (REFERENCES - 1 - k) * (SHOWN_VALUES / REFERENCES),
               SHOWN_VALUES / REFERENCES * sizeof(float));
    swapped = in;
    swapped.shown = turned;
    CHECK_OK(ctx, gsf__mini_begin(ctx, net, 1, REFERENCES, WIDTH, HEIGHT, 0, &run));
    CHECK_OK(ctx, gsf__mini_forward(&run, &in));
    for (int i = 0; i < 3 * PIXELS; i++) before[i] = (double)run.out[i];
    CHECK_OK(ctx, gsf__mini_forward(&run, &swapped));
    CHECK_NEAR(difference(run.out, before, 3 * PIXELS), 0.0, 1e-6);
    gsf__mini_end(&run);
    CHECK_OK(ctx, gsf__mini_begin(ctx, net, 1, 0, WIDTH, HEIGHT, 0, &run)); // none at all
    in.references = 0;
    in.shown = NULL;
    CHECK_OK(ctx, gsf__mini_forward(&run, &in));
    gsf__mini_end(&run);
    free(turned);
    free(before);
}

// ---- the restorer ----------------------------------------------------------------

typedef struct clip {
    float color[3 * PIXELS], alpha[PIXELS], depth[PIXELS], out[3 * PIXELS], weight[PIXELS], carried[13 * PIXELS];
} clip;

static gsf_result carry(void* user, gsf_context* ctx, int32_t frame, int32_t slot, gsf_carried* out) {
    clip* c = (clip*)user;
    gsf_image* const images[] = {&out->color, &out->residual, &out->back_color, &out->score,
                                 &out->depth, &out->angle, &out->back_ratio};
    float* at = c->carried;
    (void)ctx, (void)frame;
    out->reference = slot < 2 ? slot : -1;
    for (int i = 0; i < 7 && slot < 2; i++) {
        *images[i] = gsf_wrap_image(at, GSF_F32, WIDTH, HEIGHT, i < 3 ? 3 : 1);
        at += (i < 3 ? 3 : 1) * PIXELS;
    }
    return GSF_OK;
}

static void run_restorer(gsf_context* ctx, const gsf_restorer* mini, clip* c, gsf_result expected, int carried) {
    float* const data[5] = {c->color, c->alpha, c->depth, c->out, c->weight};
    gsf_image images[5];
    for (int i = 0; i < 5; i++) images[i] = gsf_wrap_image(data[i], GSF_F32, WIDTH, HEIGHT, i == 0 || i == 3 ? 3 : 1);
    gsf_restore_window w;
    gsf_restorer_info info;
    memset(&w, 0, sizeof w);
    memset(&info, 0, sizeof info);
    info.struct_size = sizeof info;
    CHECK_OK(ctx, mini->query_fn(mini->user, ctx, 1, WIDTH, HEIGHT, &info));
    CHECK(info.needs_carried == 3 && info.needs_depth && info.needs_alpha && info.bytes > 0.0 && info.flops > 0.0);
    w.struct_size = sizeof w;
    w.frame_count = 1;
    w.color = images;
    w.alpha = images + 1;
    w.depth = images + 2;
    w.out_color = images + 3;
    w.out_confidence = images + 4;
    if (carried) w.carry_fn = carry;
    w.carry_user = c;
    CHECK_OK(ctx, mini->begin_fn(mini->user, ctx, NULL, 0));
    CHECK_RESULT(ctx, mini->begin_fn(mini->user, ctx, NULL, 0), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, mini->restore_fn(mini->user, ctx, &w), expected);
    mini->end_fn(mini->user, ctx);
}

static void test_restorer(gsf_context* ctx) {
    const double weight = 0.05 * 0.05 / (0.05 * 0.05 + exp(-6.0)); // for an expected error of e^-3
    static clip c, from_memory, hidden;
    float *score = hidden.carried + 9 * PIXELS, *back_ratio = hidden.carried + 12 * PIXELS;
    gsf_nn_mini_desc desc;
    gsf_restorer mini;
    gsf__mini net, sizes = tiny();
    void* bytes;
    size_t size;
    float* values = (float*)(void*)&c;
    for (size_t i = 0; i < sizeof c / sizeof *values; i++) values[i] = (float)test_random_in(&mini_seed, 0.1, 1.0);
    from_memory = hidden = c;
    memset(&desc, 0, sizeof desc);
    CHECK_RESULT(ctx, gsf_nn_make_mini(ctx, &desc, &mini), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_OK(ctx, gsf__mini_make(ctx, &sizes, 5, made_path()));
    desc.path = made_path();
    CHECK_OK(ctx, gsf_nn_make_mini(ctx, &desc, &mini));
    run_restorer(ctx, &mini, &c, GSF_OK, 1);
    for (int i = 0; i < 3 * PIXELS; i++) CHECK(c.out[i] >= 0.0f && c.out[i] <= 1.0f && fabsf(c.out[i] - c.color[i]) < 0.025f);
    for (int i = 0; i < PIXELS; i++) CHECK_NEAR((double)c.weight[i], weight, 1e-6);
    score[0] = score[2] = back_ratio[1] = back_ratio[2] = 0.0f;
    run_restorer(ctx, &mini, &hidden, GSF_OK, 1);
    for (int i = 0; i < PIXELS; i++) CHECK_NEAR((double)hidden.weight[i], i == 2 ? 0.0 : weight, 1e-6); // nothing shows pixel 2
    for (int i = 0; i < PIXELS; i++) CHECK((memcmp(hidden.out + 3 * i, hidden.color + 3 * i, 12) == 0) == (i == 2));
    run_restorer(ctx, &mini, &c, GSF_ERROR_UNSUPPORTED, 0);
    gsf_destroy_restorer(ctx, &mini);
    CHECK_OK(ctx, gsf_read_file(ctx, made_path(), &bytes, &size));
    memset(&desc, 0, sizeof desc);
    desc.data = bytes;
    desc.size = size;
    CHECK_OK(ctx, gsf_nn_make_mini(ctx, &desc, &mini));
    run_restorer(ctx, &mini, &from_memory, GSF_OK, 1);
    CHECK(memcmp(c.out, from_memory.out, sizeof c.out) == 0 && memcmp(c.weight, from_memory.weight, sizeof c.weight) == 0);
    gsf_destroy_restorer(ctx, &mini);
    desc.references = GSF__MINI_MOST + 1;
    CHECK_RESULT(ctx, gsf_nn_make_mini(ctx, &desc, &mini), GSF_ERROR_INVALID_ARGUMENT);
    desc.references = 0;
    for (desc.size = 0; desc.size < size; desc.size += desc.size < 3000 ? 1 + desc.size / 20 : size / 9) // cut short
        CHECK_RESULT(ctx, gsf_nn_make_mini(ctx, &desc, &mini), GSF_ERROR_FORMAT);
    CHECK_OK(ctx, gsf__mini_open(ctx, NULL, bytes, size, &net));
    test_order(ctx, &net);
    gsf_nn_tensor* tensors = (gsf_nn_tensor*)malloc((net.weights.tensor_count + 1) * sizeof *tensors);
    for (int fault = 0; fault < 5; fault++) { // a tensor less, one more, of another shape, of another type; a NaN
        static float surplus[1];
        size_t count = net.weights.tensor_count;
        const size_t at = (size_t)(gsf_nn_find_tensor(&net.weights, "head.bias") - net.weights.tensors);
        float broken[28];
        memcpy(tensors, net.weights.tensors, count * sizeof *tensors);
        if (fault == 0) tensors[at] = tensors[--count];
        if (fault == 1) {
            const int64_t shape[1] = {1};
            tensors[count++] = gsf_nn_wrap_tensor("surplus", surplus, 1, shape);
        }
        if (fault == 2) tensors[at].shape[0] = tensors[at].count = 27;
        if (fault == 3) tensors[at].dtype = GSF_NN_I32;
        if (fault == 4) {
            memcpy(broken, tensors[at].data, sizeof broken);
            broken[3] = (float)NAN;
            tensors[at].data = broken;
        }
        CHECK_OK(ctx, gsf_nn_save_tensors(ctx, made_path(), tensors, count));
        memset(&desc, 0, sizeof desc);
        desc.path = made_path();
        CHECK_RESULT(ctx, gsf_nn_make_mini(ctx, &desc, &mini),
                     fault == 4 ? GSF_OK : fault == 3 ? GSF_ERROR_UNSUPPORTED : GSF_ERROR_FORMAT);
        if (fault == 4) run_restorer(ctx, &mini, &c, GSF_ERROR_NUMERIC, 1);
        gsf_destroy_restorer(ctx, &mini);
    }
    free(tensors);
    gsf__mini_close(ctx, &net);
    gsf_free(ctx, bytes);
}

// Kernels of a network in 8-bit integers, with a factor per output. Returns the number of tensors.
static size_t narrow(const gsf_nn_weights* w, gsf_nn_tensor* out, signed char* values, float* scales, char (*names)[64]) {
    size_t count = 0;
    for (size_t i = 0; i < w->tensor_count; i++) {
        const gsf_nn_tensor* t = w->tensors + i;
        out[count++] = *t;
        if (t->rank != 4) continue;
        const int64_t each = t->count / t->shape[0];
        for (int64_t o = 0; o < t->shape[0]; o++) {
            scales[o] = 1e-3f;
            for (int64_t k = o * each; k < (o + 1) * each; k++)
                scales[o] = fmaxf(scales[o], fabsf(((const float*)t->data)[k]) / 127.0f);
            for (int64_t k = o * each; k < (o + 1) * each; k++)
                values[k] = (signed char)lrintf(((const float*)t->data)[k] / scales[o]);
        }
        out[count - 1].data = values;
        out[count - 1].dtype = GSF_NN_I8;
        snprintf(names[i], sizeof names[i], "%s_scale", t->name);
        out[count++] = gsf_nn_wrap_tensor(names[i], scales, 1, t->shape);
        values += t->count;
        scales += t->shape[0];
    }
    return count;
}

static void test_int8(gsf_context* ctx) {
    enum { TENSORS = 80 };
    static signed char values[20000];
    static float scales[1000];
    static char names[TENSORS][64];
    static clip exact, near;
    static float random[20000];
    gsf_nn_tensor tensors[2 * TENSORS];
    gsf__mini net, narrowed, sizes = tiny();
    CHECK_OK(ctx, gsf__mini_make(ctx, &sizes, 5, made_path()));
    if (!CHECK_OK(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &net))) return;
    size_t weights = 0, outputs = 0, worst = 0;
    for (size_t i = 0; i < sizeof random / sizeof *random; i++) random[i] = (float)test_random_in(&mini_seed, -0.3, 0.3);
    for (size_t i = 0; i < net.weights.tensor_count; i++) { // a new network's heads are zero
        gsf_nn_tensor* t = net.weights.tensors + i;
        if (t->rank != 4) continue;
        t->data = random + weights;
        weights += (size_t)t->count;
        outputs += (size_t)t->shape[0];
    }
    if (!CHECK(net.weights.tensor_count <= TENSORS && weights <= sizeof values)) return;
    if (!CHECK(outputs <= sizeof scales / sizeof *scales)) return;
    const size_t count = narrow(&net.weights, tensors, values, scales, names);
    for (int fault = 0; fault < 4; fault++) { // none; a factor less; none; of another type
        gsf_nn_tensor* scale = tensors;
        while (!strstr(scale->name, "_scale")) scale++;
        const gsf_nn_tensor kept = *scale;
        if (fault == 1) scale->count = --scale->shape[0];
        if (fault == 2) scale->name = "other";
        if (fault == 3) scale->dtype = GSF_NN_I32;
        CHECK_OK(ctx, gsf_nn_save_tensors(ctx, made_path(), tensors, count));
        *scale = kept;
        CHECK_RESULT(ctx, gsf__mini_open(ctx, made_path(), NULL, 0, &narrowed), fault ? GSF_ERROR_FORMAT : GSF_OK);
        if (fault) CHECK(strstr(ctx->error, kept.name) != NULL);
        if (fault) continue;
        CHECK(narrowed.weights.tensor_count == net.weights.tensor_count);
        const signed char* q = values;
        const float* s = scales;
        for (size_t i = 0; i < net.weights.tensor_count; i++) {
            const gsf_nn_tensor *a = net.weights.tensors + i, *b = narrowed.weights.tensors + i;
            if (!CHECK(strcmp(a->name, b->name) == 0 && a->count == b->count && b->dtype == GSF_NN_F32)) break;
            if (a->rank != 4) continue;
            for (int64_t k = 0; k < a->count; k++)
                worst += ((const float*)b->data)[k] != (float)q[k] * s[k / (a->count / a->shape[0])];
            q += a->count;
            s += a->shape[0];
        }
        CHECK(worst == 0);
        gsf__mini_close(ctx, &narrowed);
    }
    float* const to = (float*)(void*)&exact;
    for (size_t i = 0; i < sizeof exact / sizeof *to; i++) to[i] = (float)test_random_in(&mini_seed, 0.1, 1.0);
    near = exact;
    for (int narrow_file = 1; narrow_file >= 0; narrow_file--) {
        gsf_restorer mini;
        gsf_nn_mini_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.path = made_path();
        CHECK_OK(ctx, gsf_nn_save_tensors(ctx, made_path(), narrow_file ? tensors : net.weights.tensors,
                                          narrow_file ? count : net.weights.tensor_count));
        CHECK_OK(ctx, gsf_nn_make_mini(ctx, &desc, &mini));
        run_restorer(ctx, &mini, narrow_file ? &near : &exact, GSF_OK, 1);
        gsf_destroy_restorer(ctx, &mini);
    }
    CHECK(memcmp(near.out, exact.out, sizeof near.out) != 0);
    for (int i = 0; i < 3 * PIXELS; i++) CHECK_NEAR((double)near.out[i], (double)exact.out[i], 0.01);
    gsf__mini_close(ctx, &net);
}

static void test_mini_memory(void) {
    static clip c;
    counter count;
    gsf_context ctx;
    memset(&count, 0, sizeof count);
    test_context_zero(&ctx);
    count_memory(&ctx, &count);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    gsf__mini sizes = tiny();
    gsf__mini_input in[1];
    CHECK_OK(&ctx, gsf__mini_make(&ctx, &sizes, 5, made_path()));
    make_inputs(in, 1, WIDTH, HEIGHT, REFERENCES, planes);
    for (size_t k = 1;; k++) {
        count.calls = 0;
        count.fail_at = k;
        gsf__mini net;
        gsf__nn_params params;
        gsf__mini_run run;
        gsf__mini_loss loss;
        gsf_nn_mini_desc desc;
        gsf_restorer mini;
        memset(&desc, 0, sizeof desc);
        memset(&params, 0, sizeof params);
        memset(&run, 0, sizeof run);
        desc.path = made_path();
        gsf_result result = gsf_nn_make_mini(&ctx, &desc, &mini);
        gsf_destroy_restorer(&ctx, &mini);
        if (!result) result = gsf__mini_open(&ctx, made_path(), NULL, 0, &net);
        else memset(&net, 0, sizeof net);
        if (!result) result = gsf__nn_make_params(&ctx, &net.weights, NULL, 1, &params);
        if (!result) result = gsf__mini_begin(&ctx, &net, 1, REFERENCES, WIDTH, HEIGHT, 1, &run);
        if (!result) result = gsf__mini_forward(&run, in);
        if (!result) result = gsf__mini_measure_loss(&run, c.out, &loss);
        if (!result) result = gsf__mini_backward(&run, &params);
        gsf__mini_end(&run);
        if (params.weights) gsf__nn_destroy_params(&ctx, &params);
        gsf__mini_close(&ctx, &net);
        if (!CHECK(count.live == 0) || result == GSF_OK) break;
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    const gsf_cpu_level best = ctx.cpu_level;
    for (int cpu = GSF_CPU_SCALAR; cpu <= (int)best; cpu++) {
        memset(&ctx, 0, sizeof ctx);
        ctx.cpu_level = (gsf_cpu_level)cpu;
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        if ((int)ctx.cpu_level != cpu) continue;
        if (cpu == GSF_CPU_SCALAR || cpu == GSF_CPU_AVX2 || cpu == GSF_CPU_AVX512) test_gradients(&ctx);
    }
    test_loss(&ctx);
    test_start(&ctx);
    test_gate(&ctx);
    test_restorer(&ctx);
    test_int8(&ctx);
    test_mini_memory();
    return test_report();
}
