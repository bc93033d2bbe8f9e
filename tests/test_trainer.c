// test_trainer.c - loss and regularisers by finite differences; training on a synthetic scene: it learns, and is
// bit-identical for any workers, after a resume and after failures; bad input is refused.
// gcc -O2 -std=c11 -I. -Itests tests/test_trainer.c -lm
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"

enum { WIDTH = 44, HEIGHT = 36, SCENE_VIEWS = 5, SPLATS = 70 };

static void for_backwards(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    const int workers = *(const int*)user;
    for (size_t i = chunk_count; i-- > 0;) body(arg, i, (int)((i * 7 + 3) % (size_t)workers));
}

// One thread, or several workers that get chunks in reverse order.
static gsf_context open_context(gsf_cpu_level level, int* workers) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.cpu_level = level;
    ctx.threads = 1;
    if (workers) {
        ctx.parallel.for_fn = for_backwards;
        ctx.parallel.worker_count = *workers;
        ctx.parallel.user = workers;
    }
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    return ctx;
}

// ---- loss ----------------------------------------------------------------------

typedef struct loss_case {
    int32_t width, height;
    int weighted, bytes;
    float lambda;
} loss_case;

static void test_loss_derivative(gsf_context* ctx) {
    static const loss_case cases[] = {{1, 1, 0, 0, 0.2f},  {3, 2, 1, 1, 0.2f},   {1, 17, 0, 1, 1.0f},
                                      {23, 1, 1, 0, 0.5f}, {13, 11, 1, 0, 0.2f}, {19, 14, 0, 1, 0.0f},
                                      {8, 8, 0, 0, 1.0f},  {11, 24, 1, 1, 1.0f},  {3, 131, 1, 1, 0.5f}};
    gsf__loss_scratch scratch;
    memset(&scratch, 0, sizeof scratch);
    uint64_t state = 5;
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        const size_t pixels = (size_t)cases[c].width * (size_t)cases[c].height, n = 3 * pixels;
        float *render = (float*)malloc(n * sizeof(float)), *photo = (float*)malloc(n * sizeof(float));
        float *weight = (float*)malloc(pixels * sizeof(float)), *d = (float*)malloc(n * sizeof(float));
        float* ignored = (float*)malloc(n * sizeof(float));
        uint8_t* bytes = (uint8_t*)malloc(n);
        for (size_t i = 0; i < n; i++) {
            bytes[i] = (uint8_t)test_random_in(&state, 0, 255.9);
            photo[i] = (float)test_random_in(&state, 0, 1);
            render[i] = (float)test_random_in(&state, -0.2, 1.2);
            const float t = cases[c].bytes ? (float)bytes[i] / 255.0f : photo[i];
            if (fabsf(render[i] - t) < 0.03f) render[i] = t + 0.04f; // away from the kinks
            if (fabsf(render[i]) < 0.02f || fabsf(render[i] - 1.0f) < 0.02f) render[i] = -0.1f;
        }
        for (size_t i = 0; i < pixels; i++) {
            weight[i] = i % 5 ? (float)test_random(&state) : 0.0f;
            for (size_t k = 0; k < 3 && weight[i] == 0.0f && cases[c].weighted; k++)
                photo[3 * i + k] = 0.0f, bytes[3 * i + k] = 0;
        }
        gsf__target target;
        memset(&target, 0, sizeof target);
        target.width = cases[c].width;
        target.height = cases[c].height;
        if (cases[c].bytes) target.u8 = bytes;
        else target.f32 = photo;
        if (cases[c].weighted) target.weight = weight;
        gsf__loss_value value, low, high;
        CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, cases[c].lambda, 3.0f, d, &value));
        double largest = 0.0;
        for (size_t i = 0; i < n; i++) largest = fmax(largest, fabs((double)d[i]));
        for (size_t i = 0; i < n; i += 1 + n / 60) {
            const float kept = render[i], step = 0.004f;
            render[i] = kept + step;
            CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, cases[c].lambda, 1.0f, ignored, &high));
            render[i] = kept - step;
            CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, cases[c].lambda, 1.0f, ignored, &low));
            render[i] = kept;
            CHECK_NEAR(d[i], 3.0 * (high.total - low.total) / 0.008, 4e-3 * largest + 1e-6);
        }
        // a weight of zero everywhere is a loss of zero; NaN in the render has no gradient
        if (cases[c].weighted) {
            memset(weight, 0, pixels * sizeof(float));
            CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, cases[c].lambda, 1.0f, ignored, &low));
            CHECK(low.total == 0.0);
        }
        render[n / 2] = NAN;
        CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, cases[c].lambda, 1.0f, d, &value));
        int finite = isfinite(value.total) && d[n / 2] == 0.0f;
        for (size_t i = 0; i < n; i++) finite = finite && isfinite(d[i]);
        CHECK(finite);
        free(render); free(photo); free(weight); free(d); free(ignored); free(bytes);
    }
    gsf__loss_destroy_scratch(ctx, &scratch);
}

// Mean of 1 - weight (1 - SSIM) and the gradient of the mean of weight (1 - SSIM) in double precision, directly from the
// formulas, with the window of the 3DGS code: taps and their products rounded to float32. weight: (height,width), NULL = 1.
static double exact_ssim(int width, int height, const float* x, const float* t, const float* weight, double* gradient) {
    const size_t n = 3 * (size_t)width * (size_t)height;
    double ssim = 0.0, *slopes = (double*)calloc(3 * n, sizeof(double));
    float window[11];
    for (int k = 0; k < 11; k++) window[k] = (float)exp(-(k - 5) * (k - 5) / 4.5) / 3.7592328f;
    for (int pass = 0; pass < 2; pass++) // slopes of every window, then what each pixel collects
        for (size_t i = 0; i < n; i++) {
            const int px = (int)(i / 3) % width, py = (int)(i / 3) / width;
            double s[5] = {0}, g[3] = {0};
            for (int y = py < 5 ? 0 : py - 5; y < height && y <= py + 5; y++)
                for (int c = px < 5 ? 0 : px - 5; c < width && c <= px + 5; c++) {
                    const size_t at = 3 * ((size_t)y * (size_t)width + (size_t)c) + i % 3;
                    const double w = window[y - py + 5] * window[c - px + 5], u = x[at], v = t[at];
                    const double terms[5] = {u, v, u * u, v * v, u * v};
                    for (int k = 0; k < 5; k++) s[k] += w * terms[k];
                    for (size_t k = 0; k < 3; k++) g[k] += w * slopes[k * n + at];
                }
            if (pass) {
                gradient[i] = -(g[0] + 2.0 * x[i] * g[1] + t[i] * g[2]) / (double)n;
                continue;
            }
            const double a1 = 2.0 * s[0] * s[1] + 1e-4, a2 = 2.0 * (s[4] - s[0] * s[1]) + 9e-4;
            const double b1 = s[0] * s[0] + s[1] * s[1] + 1e-4, b2 = s[2] - s[0] * s[0] + s[3] - s[1] * s[1] + 9e-4;
            const double m = a1 * a2 / (b1 * b2), e = -m / b2, f = 2.0 * a1 / (b1 * b2);
            const double share = weight ? weight[i / 3] : 1.0;
            slopes[i] = share * (2.0 * s[1] * a2 / (b1 * b2) - 2.0 * s[0] * m / b1 - 2.0 * s[0] * e - s[1] * f);
            slopes[n + i] = share * e;
            slopes[2 * n + i] = share * f;
            ssim += (1.0 - share * (1.0 - m)) / (double)n;
        }
    free(slopes);
    return ssim;
}

enum { LOSS_NOISE, LOSS_DARK, LOSS_SMOOTH, LOSS_BRIGHT, LOSS_LEVEL, LOSS_FLAT_LEVEL, LOSS_FLAT, LOSS_FLAT_FAR, LOSS_EDGES,
       LOSS_EDGES_MOVED, LOSS_HDR, LOSS_CASES };

// Error bounds of the loss: the mean SSIM; its gradient (relative to the largest one) in images of 37 x 141 and in
// smaller ones; and the gradient with weights. At most twice the values measured over all CPU levels. Where images are
// flat or equal on both sides of an edge, large terms of the gradient nearly cancel.
static const struct loss_bar { const char* name; double ssim, gradient, small_gradient, weighted_gradient; }
    loss_bars[LOSS_CASES] = {
        {"noise", 2.5e-8, 4.2e-7, 4.4e-7, 7.3e-7},
        {"dark noise", 1.2e-8, 6e-7, 4.6e-7, 5.7e-7},
        {"smooth", 1.2e-9, 5e-6, 5e-6, 5e-6},
        {"bright, little noise", 1.9e-11, 6.5e-7, 5.6e-7, 5e-7},
        {"one grey level apart", 6.5e-11, 8.3e-7, 7.6e-7, 1e-6},
        {"flat, one grey level apart", 4.8e-12, 2.3e-5, 1.6e-5, 5.6e-7},
        {"flat and bright", 1.5e-10, 1.6e-5, 1.4e-5, 6.3e-7},
        {"flat, far apart", 7.7e-8, 2.9e-5, 2.5e-5, 6e-7},
        {"edges", 4.6e-9, 8e-7, 7e-5, 6.3e-7},
        {"moved edges", 1.5e-7, 1e-6, 1e-6, 8.8e-7},
        {"beyond 0..1", 2.2e-8, 4.6e-7, 3.4e-7, 6.4e-7}};

// Value i of the photo and of the render; rows have `width` pixels.
static void loss_values(int kind, int width, int i, uint64_t* state, float* photo, float* render) {
    const double x = i / 3 % width, y = i / 3 / width, wave = 0.5 + 0.45 * sin(0.07 * x + i % 3) * cos(0.05 * y);
    const double a = test_random(state), b = test_random(state), grey = floor(250.0 * a);
    const int bars = (i / 3 % width + 3) / 8 % 2, moved = (i / 3 % width + 6) / 8 % 2;
    const double pairs[LOSS_CASES][2] = {{a, b}, {0.02 * a, 0.02 * b}, {wave, wave + 0.03 * sin(0.11 * x + 0.04 * y)},
        {0.95 + 1e-3 * a, 0.95 + 1e-3 * b}, {grey / 255.0, (grey + (b < 0.5 ? -1.0 : 1.0)) / 255.0},
        {200.0 / 255.0, 201.0 / 255.0}, {0.97, 0.99}, {0.2 + 0.3 * (i % 3), 0.8 - 0.2 * (i % 3)},
        {bars ? 0.97 : 0.03, (bars ? 0.97 : 0.03) + 0.02 * (b - 0.5)}, {bars ? 0.9 : 0.1, moved ? 0.9 : 0.1},
        {4.0 * a - 1.0, 4.0 * b - 1.0}};
    *photo = (float)pairs[kind][0];
    *render = (float)pairs[kind][1];
}

// Mean SSIM and gradient against double precision, for any image content and small sizes. Three bands of rows, the last
// ones in any order by any worker: bit-identical.
static void test_loss_accuracy(gsf_cpu_level level) {
    enum { N = 3 * 37 * 141 };
    static const int sizes[][2] = {{37, 141}, {1, 1}, {2, 1}, {1, 9}, {11, 3}, {13, 29}};
    static float render[N], photo[N], d[N], other[N];
    static double exact[N];
    int workers = 3;
    gsf_context plain = open_context(level, NULL), shuffled = open_context(level, &workers);
    gsf__loss_scratch scratch, another;
    memset(&scratch, 0, sizeof scratch);
    memset(&another, 0, sizeof another);
    gsf__target target;
    memset(&target, 0, sizeof target);
    target.f32 = photo;
    uint64_t state = 11;
    for (int c = 0; c < LOSS_CASES; c++)
        for (size_t s = 0; s < sizeof sizes / sizeof *sizes; s++) {
            const int W = sizes[s][0], H = sizes[s][1], n = 3 * W * H;
            target.width = W;
            target.height = H;
            for (int i = 0; i < n; i++) loss_values(c, W, i, &state, &photo[i], &render[i]);
            gsf__loss_value value, again;
            CHECK_OK(&plain, gsf__loss(&plain, &scratch, &target, render, 1.0f, 1.0f, d, &value));
            CHECK_OK(&shuffled, gsf__loss(&shuffled, &another, &target, render, 1.0f, 1.0f, other, &again));
            CHECK(memcmp(d, other, (size_t)n * sizeof *d) == 0 && memcmp(&value, &again, sizeof value) == 0);
            for (int i = 0; i < n; i++) { // both are clamped
                other[i] = fminf(fmaxf(render[i], 0.0f), 1.0f);
                photo[i] = fminf(fmaxf(photo[i], 0.0f), 1.0f);
            }
            const double ssim = exact_ssim(W, H, other, photo, NULL, exact);
            for (int i = 0; i < n; i++) exact[i] = render[i] >= 0.0f && render[i] <= 1.0f ? exact[i] : 0.0;
            const struct loss_bar* bar = &loss_bars[c];
            CHECK_NEAR(value.ssim, ssim, bar->ssim);
            CHECK_NEAR(value.total, 1.0 - ssim, bar->ssim);
            const double share = s == 0 ? bar->gradient : bar->small_gradient; // 1e-15: where both images are the same
            test_compare_floats(bar->name, d, exact, (size_t)n, share * test_max_abs(exact, (size_t)n) + 1e-15);
        }
    gsf__loss_destroy_scratch(&plain, &scratch);
    gsf__loss_destroy_scratch(&shuffled, &another);
}

// The same with weights, a third of which are 0: the reference has black in both images there, and no gradient. What is
// rendered there changes no bit.
static void test_loss_weights(gsf_cpu_level level) {
    enum { W = 37, H = 141, PIXELS = W * H, N = 3 * PIXELS };
    static float render[N], photo[N], d[N], other[N], weight[PIXELS];
    static double exact[N];
    gsf_context ctx = open_context(level, NULL);
    gsf__loss_scratch scratch;
    memset(&scratch, 0, sizeof scratch);
    gsf__target target;
    memset(&target, 0, sizeof target);
    target.width = W;
    target.height = H;
    target.f32 = photo;
    target.weight = weight;
    uint64_t state = 12;
    for (int kind = 0; kind < LOSS_CASES; kind++) {
        for (int i = 0; i < N; i++) loss_values(kind, W, i, &state, &photo[i], &render[i]);
        for (int i = 0; i < PIXELS; i++) { // blocks, scattered pixels and a column of bands of zeros
            weight[i] = i / 40 % 3 == 0 || i % 17 == 0 || i % W < 9 ? 0.0f : (float)test_random_in(&state, 0.1, 1);
            for (int k = 3 * i; k < 3 * i + 3; k++) {
                photo[k] = weight[i] > 0.0f ? fminf(fmaxf(photo[k], 0.0f), 1.0f) : 0.0f;
                other[k] = weight[i] > 0.0f ? fminf(fmaxf(render[k], 0.0f), 1.0f) : 0.0f;
            }
        }
        gsf__loss_value value, again;
        CHECK_OK(&ctx, gsf__loss(&ctx, &scratch, &target, render, 1.0f, 1.0f, d, &value));
        const double ssim = exact_ssim(W, H, other, photo, weight, exact);
        double l1 = 0.0;
        for (int i = 0; i < N; i++) {
            const float w = weight[i / 3];
            l1 += (double)w * fabs((double)other[i] - (double)photo[i]) / N;
            if (w == 0.0f || !(render[i] >= 0.0f && render[i] <= 1.0f)) exact[i] = 0.0;
        }
        CHECK_NEAR(value.ssim, ssim, loss_bars[kind].ssim);
        CHECK_NEAR(value.l1, l1, 1e-6);
        test_compare_floats(loss_bars[kind].name, d, exact, N, loss_bars[kind].weighted_gradient * test_max_abs(exact, N));
        for (int i = 0; i < N; i++)
            if (weight[i / 3] == 0.0f) render[i] = i % 2 ? (float)test_random_in(&state, -1, 2) : NAN;
        CHECK_OK(&ctx, gsf__loss(&ctx, &scratch, &target, render, 1.0f, 1.0f, other, &again));
        CHECK(memcmp(d, other, sizeof d) == 0 && memcmp(&value, &again, sizeof value) == 0);
    }
    gsf__loss_destroy_scratch(&ctx, &scratch);
}

static void test_smoothness_derivative(gsf_context* ctx) {
    enum { W = 9, H = 70 }; // two bands
    float photo[3 * W * H], render[3 * W * H], ignored[3 * W * H], depth[W * H], d[W * H], other[W * H];
    uint64_t state = 9;
    for (int i = 0; i < 3 * W * H; i++) photo[i] = render[i] = (float)test_random(&state);
    // between 1 and 3, and no two neighbours close to the kink at the same depth
    for (int i = 0; i < W * H; i++) depth[i] = i % 7 == 3 ? 0.0f : 1.0f + 2.0f * (float)(i * 257 % (W * H)) / (W * H);
    gsf__loss_scratch scratch;
    memset(&scratch, 0, sizeof scratch);
    gsf__target target;
    memset(&target, 0, sizeof target);
    target.width = W;
    target.height = H;
    target.f32 = photo;
    gsf__loss_value value;
    CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, 0.2f, 1.0f, ignored, &value));
    (void)gsf__depth_smoothness(ctx, &scratch, &target, depth, 2.0f, 0.7f, d);
    for (int i = 0; i < W * H; i++) {
        if (depth[i] == 0.0f) {
            CHECK(d[i] == 0.0f);
            continue;
        }
        const float kept = depth[i];
        depth[i] = kept + 1e-3f;
        const double high = gsf__depth_smoothness(ctx, &scratch, &target, depth, 2.0f, 0.7f, other);
        depth[i] = kept - 1e-3f;
        const double low = gsf__depth_smoothness(ctx, &scratch, &target, depth, 2.0f, 0.7f, other);
        depth[i] = kept;
        CHECK_NEAR(d[i], (high - low) / 2e-3, 2e-5);
    }
    gsf__loss_destroy_scratch(ctx, &scratch);
}

// The gradient has the same bits at every level, also for odd widths, and that of bytes is that of the same floats.
static void test_smoothness_levels(gsf_cpu_level last) {
    enum { W = 37, H = 5 };
    float floats[3 * W * H], render[3 * W * H], ignored[3 * W * H], depth[W * H], scalar[2][W * H], d[W * H];
    uint8_t bytes[3 * W * H];
    uint64_t state = 31;
    for (int i = 0; i < 3 * W * H; i++) {
        bytes[i] = (uint8_t)(256.0 * test_random(&state));
        floats[i] = render[i] = (float)bytes[i] / 255.0f;
    }
    for (int i = 0; i < W * H; i++) depth[i] = i % 11 == 3 ? 0.0f : i % 11 == 4 ? 2.0f : 1.0f + (float)test_random(&state);
    for (int32_t width = 1; width <= W; width += 6)
        for (int level = GSF_CPU_SCALAR; level <= (int)last; level++) {
            double sums[2];
            for (int u8 = 0; u8 < 2; u8++) {
                gsf_context ctx = open_context((gsf_cpu_level)level, NULL);
                gsf__loss_scratch scratch;
                gsf__target target;
                gsf__loss_value value;
                memset(&scratch, 0, sizeof scratch);
                memset(&target, 0, sizeof target);
                target.width = width;
                target.height = H;
                if (u8) target.u8 = bytes;
                else target.f32 = floats;
                CHECK_OK(&ctx, gsf__loss(&ctx, &scratch, &target, render, 0.2f, 1.0f, ignored, &value));
                sums[u8] = gsf__depth_smoothness(&ctx, &scratch, &target, depth, 2.0f, 0.7f, d);
                if (level == GSF_CPU_SCALAR) memcpy(scalar[u8], d, sizeof d);
                CHECK(!memcmp(d, scalar[u8], (size_t)(width * H) * sizeof(float)));
                for (int i = 0; u8 && i < width * H; i++) CHECK_NEAR(d[i], scalar[0][i], 1e-5 * (1e-3 + fabs(scalar[0][i])));
                gsf__loss_destroy_scratch(&ctx, &scratch);
            }
            double exact = 0.0; // as documented, over all pairs
            for (int p = 0; p < width * H; p++)
                for (int k = 0; k < 2; k++) {
                    const int q = k ? p + width : p + 1;
                    if (k ? q >= width * H : q % width == 0) continue;
                    if (depth[p] == 0.0f || depth[q] == 0.0f) continue;
                    double mean = 0.0;
                    for (int c = 0; c < 3; c++) mean += fabs((double)bytes[3 * p + c] - (double)bytes[3 * q + c]) / 765.0;
                    exact += fabs(2.0 / (double)depth[p] - 2.0 / (double)depth[q]) / (1.0 + 100.0 * mean * mean);
                }
            exact *= 0.7 / (width * H);
            CHECK_NEAR(sums[0], exact, 1e-6 * exact);
            CHECK_NEAR(sums[1], exact, 1e-6 * exact);
        }
}

// ---- Adam and regularisers on a bare model ---------------------------------------

static gsf__model make_small_model(gsf_context* ctx, size_t count, int32_t sh_degree) {
    gsf__model model;
    memset(&model, 0, sizeof model);
    model.sh_degree = sh_degree;
    if (!CHECK_OK(ctx, gsf__model_reserve(ctx, &model, count))) exit(2);
    model.count = count;
    uint64_t state = 3;
    for (int g = 0; g < GSF__GROUPS; g++)
        for (size_t i = 0; i < count * model.groups[g].width; i++)
            model.groups[g].value[i] = (float)test_random_in(&state, -2, 2);
    for (size_t i = 0; i < count; i++) model.ids[i] = (uint32_t)i;
    model.next_id = (uint32_t)count;
    return model;
}

// Bad gradients have no effect and are counted; rows after them are unchanged.
static void test_adam_rejects(gsf_context* ctx) {
    for (int32_t degree = 0; degree <= 3; degree++) {
        gsf__model model = make_small_model(ctx, 37, degree);
        gsf__group* sh = &model.groups[GSF__SH];
        for (size_t i = 37 * sh->width; i < model.capacity * sh->width; i++) sh->grad[i] = 1.0f;
        const float before = sh->value[2], quat = model.groups[GSF__QUATS].value[147];
        sh->grad[2] = NAN;
        model.groups[GSF__QUATS].grad[147] = -INFINITY;
        model.groups[GSF__OPACITY].grad[36] = 1e30f;
        model.groups[GSF__MEANS].grad[0] = -2.0f;
        const float mean = model.groups[GSF__MEANS].value[0];
        gsf__adam_rates rates = {0.5, 0.1, 0.1, 0.1, 0.1, 0.1};
        CHECK(gsf__adam_step(ctx, &model, &rates, 1, degree + 1) == 3);
        CHECK(sh->value[2] == before && model.groups[GSF__QUATS].value[147] == quat && sh->m[2] == 0.0f);
        CHECK_NEAR(model.groups[GSF__MEANS].value[0], mean + 0.5f, 1e-6); // the first step is the rate
        CHECK(sh->grad[37 * sh->width] == 1.0f && sh->value[37 * sh->width] == 0.0f);
        rates.means = 5e37; // would overflow float
        model.groups[GSF__MEANS].value[0] = 3e38f;
        model.groups[GSF__MEANS].grad[0] = -2.0f;
        CHECK(gsf__adam_step(ctx, &model, &rates, 2, degree + 1) == 1);
        CHECK(model.groups[GSF__MEANS].value[0] == 3e38f);
        gsf__model_destroy(ctx, &model);
    }
}

static void test_adam_bands(gsf_context* ctx) { // skipping bands that never had a gradient changes nothing
    for (int32_t degree = 1; degree <= 3; degree++)
        for (int32_t bands = 1; bands <= degree; bands++) {
            gsf__model a = make_small_model(ctx, 21, degree), b = make_small_model(ctx, 21, degree);
            const gsf__adam_rates rates = {0.1, 0.2, 0.3, 0.4, 0.5, 0.6};
            for (int32_t step = 1; step <= 3; step++) {
                for (size_t i = 0; i < 21; i++)
                    for (int32_t k = 0; k < 3 * bands * bands; k++)
                        a.groups[GSF__SH].grad[i * a.groups[GSF__SH].width + (size_t)k] =
                            b.groups[GSF__SH].grad[i * a.groups[GSF__SH].width + (size_t)k] = sinf((float)(step + k));
                CHECK(gsf__adam_step(ctx, &a, &rates, step, degree + 1) == 0);
                CHECK(gsf__adam_step(ctx, &b, &rates, step, bands) == 0);
            }
            CHECK(memcmp(a.groups[GSF__SH].value, b.groups[GSF__SH].value,
                         21 * a.groups[GSF__SH].width * sizeof(float)) == 0);
            gsf__model_destroy(ctx, &a);
            gsf__model_destroy(ctx, &b);
        }
}

static double relative(float actual, double expected) { // a value around zero: to 0.2
    return fabs((double)actual - expected) / fmax(fabs(expected), 0.2);
}

// SH rows in blocks that are skipped for 1 to 500 steps against rows updated in every step, both with the same
// gradients, of magnitudes from far below eps upwards; compared when their block is drawn and at the end. Also the
// dense model in double.
static void test_lazy_adam(gsf_context* ctx) {
    enum { BLOCKS = 33, DRAWN = 3, COUNT = BLOCKS * GSF__BLOCK - 7, STEPS = 1000, WIDE = 48 };
    gsf__model dense = make_small_model(ctx, COUNT, 3), lazy = make_small_model(ctx, COUNT, 3);
    gsf__lazy state;
    const gsf__adam_rates rates = {1e-3, 5e-3, 1e-3, 0.025, 2.5e-3, 1.25e-4};
    gsf__lazy_prepare(ctx->cpu_level, &state, &lazy, &rates, 0, 1);
    lazy.lazy = &state;
    gsf__group *a = &dense.groups[GSF__SH], *b = &lazy.groups[GSF__SH];
    double* exact = (double*)calloc(3 * COUNT * WIDE, sizeof(double));
    double *m = exact + COUNT * WIDE, *v = m + COUNT * WIDE;
    for (size_t i = 0; i < COUNT * WIDE; i++) exact[i] = (double)a->value[i];
    int left[BLOCKS], drawn[BLOCKS], longest = 0, replayed = 0; // a block is drawn when its first DRAWN splats are
    uint64_t random = 31;
    double worst = 0.0, sum[3] = {0.0, 0.0, 0.0}, total = 0.0, worst_exact[2] = {0.0, 0.0};
    for (int i = 0; i < BLOCKS; i++) left[i] = i % 7, drawn[i] = i % 2;
    for (int32_t t = 1; t <= STEPS; t++) {
        const int32_t bands = 1 + t / 150 < 4 ? 1 + t / 150 : 4;
        for (size_t i = 0; i < BLOCKS; i++) {
            if (left[i]-- <= 0) { // skipped for 1 to 500 steps, mostly few; drawn for 1 to 20
                drawn[i] = !drawn[i];
                left[i] = (int)exp(test_random_in(&random, 0.0, drawn[i] ? log(20.0) : log(500.9))) - 1;
                if (!drawn[i] && left[i] + 1 > longest) longest = left[i] + 1;
            }
            if (!drawn[i]) continue;
            for (size_t k = i * GSF__BLOCK * WIDE; k < (i * GSF__BLOCK + DRAWN) * WIDE; k++)
                replayed += lazy.rest[i] && b->m[k] != 0.0f && b->v[k] < GSF__LAZY_LEAST_V;
            gsf__lazy_wake(&state, i * GSF__BLOCK + (i % 4) * 8);
            for (size_t j = 0; j < DRAWN; j++) {
                const size_t at = (i * GSF__BLOCK + j) * WIDE, kind = DRAWN * i + j;
                const double size = pow(10.0, kind < 64 ? -(double)(kind % 8) - 1.0 : -(double)(kind % 16) - 6.0);
                for (size_t k = 0; k < WIDE; k++) {
                    worst = fmax(worst, relative(b->value[at + k], (double)a->value[at + k]));
                    if ((int32_t)k < 3 * bands * bands)
                        a->grad[at + k] = b->grad[at + k] = (float)(size * test_random_in(&random, -0.7, 1.0));
                }
            }
        }
        for (size_t k = 0; k < 4 * COUNT; k++)
            dense.groups[GSF__QUATS].grad[k] = lazy.groups[GSF__QUATS].grad[k] = sinf((float)(t + (int)k));
        const double c1 = 1.0 - pow(0.9, t), c2 = sqrt(1.0 - pow(0.999, t));
        for (size_t i = 0; i < COUNT * WIDE; i++) {
            if (i / WIDE % GSF__BLOCK >= DRAWN) continue; // never moves
            const double g = (double)a->grad[i], rate = i % WIDE < 3 ? rates.sh_dc : rates.sh_rest;
            m[i] += (g - m[i]) * (double)0.1f;
            v[i] = v[i] * (double)0.999f + g * g * (double)0.001f;
            exact[i] -= rate / c1 * m[i] / (sqrt(v[i]) / c2 + 1e-15);
        }
        CHECK(gsf__adam_step(ctx, &dense, &rates, t, bands) == 0);
        CHECK(gsf__adam_step(ctx, &lazy, &rates, t, bands) == 0);
    }
    gsf__parallel_for(ctx, gsf__model_chunks(COUNT), gsf__lazy_all_chunk, &state);
    for (size_t i = 0; i < COUNT * WIDE; i++) {
        const double x = (double)a->value[i], y = (double)b->value[i];
        if (i / WIDE % GSF__BLOCK >= DRAWN) {
            CHECK(x == exact[i] && y == exact[i]);
            continue;
        }
        worst = fmax(worst, relative(b->value[i], x));
        worst_exact[0] = fmax(worst_exact[0], relative(a->value[i], exact[i]));
        worst_exact[1] = fmax(worst_exact[1], relative(b->value[i], exact[i]));
        sum[0] += (y - x) * (y - x);
        sum[1] += (x - exact[i]) * (x - exact[i]);
        sum[2] += (y - exact[i]) * (y - exact[i]);
        total += exact[i] * exact[i];
    }
    printf("lazy Adam (%s): rel L2 %.2g, worst %.2g against dense; against double: dense %.2g, %.2g, lazy %.2g, %.2g\n",
           gsf_describe_cpu_level(ctx->cpu_level), sqrt(sum[0] / total), worst, sqrt(sum[1] / total), worst_exact[0],
           sqrt(sum[2] / total), worst_exact[1]);
    CHECK(longest > 400 && replayed > 100);
    CHECK(sqrt(sum[0] / total) < 1e-6 && sum[0] > 0.0);
    CHECK(sum[2] < sum[1] && worst_exact[1] < 1.1 * worst_exact[0]); // what differs is the rounding of the dense steps
    CHECK(worst < 5e-6);
    CHECK(memcmp(dense.groups[GSF__QUATS].value, lazy.groups[GSF__QUATS].value, 4 * COUNT * sizeof(float)) == 0);
    for (size_t i = 0; i < BLOCKS; i++) CHECK(lazy.rest[i] == 0);
    free(exact);
    gsf__model_destroy(ctx, &dense);
    gsf__model_destroy(ctx, &lazy);
}

static void test_regularisers(gsf_context* ctx) {
    double worst = 0.0;
    for (float x = -86.0f; x < 88.0f; x += 0.0137f)
        worst = fmax(worst, fabs((double)gsf__exp(x) / exp((double)x) - 1.0));
    CHECK_NEAR(worst, 0.0, 3e-7);
    CHECK(gsf__exp(-1000.0f) == 0.0f);

    gsf__model model = make_small_model(ctx, 700, 0);
    gsf__penalty_job penalty = {&model, 0.25f, 0.5f};
    gsf__parallel_for(ctx, gsf__model_chunks(model.count), gsf__penalty_chunk, &penalty);
    for (size_t i = 0; i < 3 * model.count; i += 17) { // derivative of 0.25 exp(s)
        const double s = (double)model.groups[GSF__SCALES].value[i];
        CHECK_NEAR(model.groups[GSF__SCALES].grad[i], 0.25 * (exp(s + 1e-4) - exp(s - 1e-4)) / 2e-4, 1e-6 * exp(s));
    }
    float* logits = model.groups[GSF__OPACITY].value;
    for (size_t i = 0; i < model.count; i += 17) { // derivative of 0.5 opacity
        const double x = (double)logits[i], low = 1.0 / (1.0 + exp(1e-4 - x)), high = 1.0 / (1.0 + exp(-1e-4 - x));
        CHECK_NEAR(model.groups[GSF__OPACITY].grad[i], 0.5 * (high - low) / 2e-4, 1e-6);
    }
    gsf__decay_job decay = {&model, 0.9};
    logits[0] = 80.0f;
    logits[1] = -90.0f;
    double before[700];
    for (size_t i = 0; i < 700; i++) before[i] = 1.0 / (1.0 + exp(-(double)logits[i]));
    gsf__parallel_for(ctx, gsf__model_chunks(model.count), gsf__decay_chunk, &decay);
    for (size_t i = 0; i < 700; i++) CHECK_NEAR(1.0 / (1.0 + exp(-(double)logits[i])), 0.9 * before[i], 1e-6);

    gsf__dropout_job dropout = {&model, 4, 77, 0.3};
    gsf__parallel_for(ctx, gsf__model_chunks(model.count), gsf__dropout_chunk, &dropout);
    size_t hidden = 0;
    for (size_t i = 0; i < model.count; i++) hidden += model.hidden[i];
    CHECK(hidden > 150 && hidden < 270);
    gsf__model_destroy(ctx, &model);
}

static void test_cap(gsf_context* ctx) { // close to max_splats, only splats with the largest gradients are densified
    gsf__model model = make_small_model(ctx, 100, 0);
    for (size_t i = 0; i < 100; i++) {
        model.grad_sum[0][i] = (float)((i * 37) % 100);
        model.visits[0][i] = 2;
    }
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.grad = 10.0f;
    rule.clone_scale = 1.0;
    rule.prune_opacity = 1e-6;
    size_t clones, splits;
    rule.max_splats = 1000;
    gsf__densify_select(&model, &rule, &clones, &splits);
    CHECK(clones + splits == 80);
    rule.max_splats = 107;
    gsf__densify_select(&model, &rule, &clones, &splits);
    CHECK(clones + splits == 7);
    for (size_t i = 0; i < 100; i++) CHECK((model.action[i] != GSF__KEEP) == ((i * 37) % 100 >= 93));
    CHECK_OK(ctx, gsf__model_reserve(ctx, &model, 100 + clones + 2 * splits));
    gsf__densify_apply(&model, &rule, clones, splits);
    CHECK(model.count == 107);
    rule.max_splats = 50;
    gsf__densify_select(&model, &rule, &clones, &splits);
    CHECK(clones + splits == 0);
    gsf__model_destroy(ctx, &model);
}

// With shared opacities, two new splats are as opaque as the old one, and a split is symmetric along its longest axis.
static void test_shared(gsf_context* ctx) {
    enum { COUNT = 40 };
    gsf__model model = make_small_model(ctx, COUNT, 0), was = make_small_model(ctx, COUNT, 0);
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.grad = 1.0f;
    rule.clone_scale = 3.0; // log-scales are within -2..2, so that some are cloned and some split
    rule.prune_opacity = 1e-6;
    rule.max_splats = 1000;
    rule.shared = 1;
    for (size_t i = 0; i < COUNT; i++) model.grad_sum[0][i] = 2.0f, model.visits[0][i] = 1;
    was.groups[GSF__OPACITY].value[0] = model.groups[GSF__OPACITY].value[0] = 200.0f; // opacity 1 stays finite
    size_t clones, splits;
    gsf__densify_select(&model, &rule, &clones, &splits);
    CHECK(clones + splits == COUNT && clones > 5 && splits > 5);
    uint8_t action[COUNT];
    memcpy(action, model.action, sizeof action);
    CHECK_OK(ctx, gsf__model_reserve(ctx, &model, COUNT + clones + 2 * splits));
    gsf__densify_apply(&model, &rule, clones, splits);
    CHECK(model.count == 2 * COUNT);
    size_t kept = 0, clone = clones, part = 2 * clones;
    for (size_t i = 0; i < COUNT; i++) {
        const int split = action[i] == GSF__SPLIT;
        const size_t rows[2] = {split ? part : kept, split ? part + splits : clone};
        if (split) part++;
        else kept++, clone++;
        const float *mean = was.groups[GSF__MEANS].value + 3 * i, *scale = was.groups[GSF__SCALES].value + 3 * i;
        const double opacity = 1.0 / (1.0 + exp(-(double)was.groups[GSF__OPACITY].value[i]));
        double clear = 1.0, apart = 0.0, longest = -INFINITY;
        for (int a = 0; a < 3; a++) longest = fmax(longest, (double)scale[a]);
        for (int k = 0; k < 2; k++) {
            const float logit = model.groups[GSF__OPACITY].value[rows[k]];
            CHECK(isfinite(logit));
            clear *= 1.0 / (1.0 + exp((double)logit));
            for (int a = 0; a < 3; a++) {
                const float now = model.groups[GSF__SCALES].value[3 * rows[k] + (size_t)a];
                const int halved = split && (double)scale[a] == longest;
                CHECK_NEAR(now, (double)scale[a] + (halved ? log(0.66) : 0.0), 1e-6);
            }
        }
        CHECK_NEAR(clear, 1.0 - opacity, 1e-5);
        for (size_t a = 0; a < 3; a++) {
            const double first = (double)model.groups[GSF__MEANS].value[3 * rows[0] + a];
            const double second = (double)model.groups[GSF__MEANS].value[3 * rows[1] + a];
            CHECK_NEAR(0.5 * (first + second), (double)mean[a], 2e-6);
            apart += (first - second) * (first - second);
        }
        CHECK_NEAR(sqrt(apart), split ? exp(longest) : 0.0, 1e-5);
    }
    gsf__model_destroy(ctx, &model);
    gsf__model_destroy(ctx, &was);
}

// ---- MCMC on a bare model --------------------------------------------------------

// The copies together are as opaque as the single splat was, in the centre and on average along a ray through it.
static void test_mcmc_share(void) {
    static const double opacities[] = {0.006, 0.3, 0.9, 0.9999};
    static const uint32_t numbers[] = {1, 2, 3, 10, 51};
    for (size_t c = 0; c < 4; c++)
        for (size_t k = 0; k < 5; k++) {
            const double o = opacities[c];
            const uint32_t n = numbers[k];
            double each, sum = 0.0, ray = 0.0;
            const double factor = gsf__mcmc_share(1.0 - o, n, &each);
            CHECK_NEAR(1.0 - pow(1.0 - each, n), o, 1e-12);
            for (uint32_t i = 1; i <= n; i++) { // the paper's formula, verbatim
                double binomial = 1.0;
                for (uint32_t j = 0; j < i; j++) {
                    sum += binomial * (j % 2 ? -1.0 : 1.0) * pow(each, j + 1) / sqrt(j + 1.0);
                    binomial *= (double)(i - 1 - j) / (double)(j + 1);
                }
            }
            CHECK_NEAR(factor, o / sum, 1e-7);
            for (int x = -900; x <= 900; x++) // in hundredths of the copies' sigma
                ray += 0.01 * (1.0 - pow(1.0 - each * exp(-0.5e-4 * x * x), n));
            CHECK_NEAR(factor * ray / (o * 2.5066282746), 1.0, 1e-6);
        }
}

// Faint splats are relocated as copies of others, new ones are added up to the budget, and opacity at each position is
// preserved.
static void test_mcmc_densify(gsf_context* ctx) {
    enum { COUNT = 400, DEAD = 90, BUDGET = 415 };
    gsf__model model = make_small_model(ctx, COUNT, 1);
    float* logits = model.groups[GSF__OPACITY].value;
    double before[COUNT];
    for (size_t i = 0; i < COUNT; i++) {
        if (i % 4 == 0 && i < 4 * DEAD) logits[i] = -6.0f - (float)i;
        model.groups[GSF__MEANS].value[3 * i] = (float)i; // identifies a copy's source
        before[i] = 1.0 / (1.0 + exp(-(double)logits[i]));
        for (int g = 0; g < GSF__GROUPS; g++)
            for (size_t k = 0; k < model.groups[g].width; k++)
                model.groups[g].m[i * model.groups[g].width + k] = model.groups[g].v[i * model.groups[g].width + k] = 1.0f;
    }
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.prune_opacity = 0.005;
    rule.max_splats = BUDGET;
    rule.seed = 8;
    CHECK(gsf__mcmc_growth(COUNT, BUDGET) == 15 && gsf__mcmc_growth(COUNT, 10) == 0);
    CHECK(gsf__mcmc_growth(COUNT, 1000) == 20);
    CHECK_OK(ctx, gsf__model_reserve(ctx, &model, BUDGET));
    gsf__mcmc_densify(&model, &rule);
    logits = model.groups[GSF__OPACITY].value;
    CHECK(model.count == BUDGET && model.next_id == COUNT + DEAD + 15);
    double clear[COUNT];
    int copies[COUNT] = {0}, opaque = 0, faint = 0;
    for (size_t i = 0; i < COUNT; i++) clear[i] = 1.0;
    for (size_t i = 0; i < BUDGET; i++) {
        const size_t at = (size_t)model.groups[GSF__MEANS].value[3 * i];
        clear[at] *= 1.0 / (1.0 + exp((double)logits[i]));
        copies[at]++;
        CHECK(logits[i] > -5.3f && model.visits[0][i] == 0 && model.visits[1][i] == 0);
    }
    for (size_t i = 0; i < BUDGET; i++) { // only splats that are neither copies nor copied keep their moments
        const size_t at = (size_t)model.groups[GSF__MEANS].value[3 * i];
        for (int g = 0; g < GSF__GROUPS; g++) {
            const float expected = copies[at] > 1 ? 0.0f : 1.0f;
            CHECK(model.groups[g].m[i * model.groups[g].width] == expected);
            CHECK(model.groups[g].v[(i + 1) * model.groups[g].width - 1] == expected);
        }
        CHECK((model.ids[i] >= COUNT) == (i >= COUNT || (i % 4 == 0 && i < 4 * DEAD)));
    }
    for (size_t i = 0; i < COUNT; i++) {
        const int dead = i % 4 == 0 && i < 4 * DEAD;
        CHECK(dead == (copies[i] == 0));
        if (!dead) CHECK_NEAR(1.0 - clear[i], before[i], 1e-6);
        if (!dead && before[i] > 0.7) opaque += copies[i] - 1;
        if (!dead && before[i] < 0.3) faint += copies[i] - 1;
    }
    CHECK(opaque > 2 * faint && opaque + faint > 50); // about 0.8 to 0.2

    for (size_t i = 0; i < BUDGET; i++) logits[i] = -9.0f; // nothing to copy
    gsf__mcmc_densify(&model, &rule);
    CHECK(model.count == BUDGET && model.next_id == COUNT + DEAD + 15 && logits[0] == -9.0f);
    gsf__model_destroy(ctx, &model);
}

// A splat that is shared among so many copies that they are clamped to prune_opacity is not dead: the next densification
// relocates none of them.
static void test_mcmc_clamped(gsf_context* ctx) {
    enum { COUNT = 60 };
    gsf__model model = make_small_model(ctx, COUNT, 0);
    float* logits = model.groups[GSF__OPACITY].value;
    for (size_t i = 0; i < COUNT; i++) logits[i] = i == 7 ? -2.0f : -9.0f;
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.prune_opacity = 0.005;
    rule.max_splats = COUNT;
    rule.seed = 8;
    gsf__mcmc_densify(&model, &rule);
    CHECK(model.count == COUNT && model.next_id == COUNT + COUNT - 1);
    for (size_t i = 0; i < COUNT; i++) CHECK_NEAR(1.0 / (1.0 + exp(-(double)logits[i])), 0.005, 1e-8);
    logits[7] = 2.0f; // now there is a splat that dead ones would be relocated to
    gsf__mcmc_densify(&model, &rule);
    CHECK(model.count == COUNT && model.next_id == COUNT + COUNT - 1 && logits[7] == 2.0f);
    gsf__model_destroy(ctx, &model);
}

// The covariance of the noise is that of the splat times the rate; faint splats get the full noise, opaque ones none.
static void test_mcmc_noise(gsf_context* ctx) {
    enum { COUNT = 4000 };
    gsf__model model = make_small_model(ctx, COUNT, 0);
    double square[3] = {0, 0, 0};
    for (size_t i = 0; i < COUNT; i++) {
        const float quat[4] = {0.5f, 0.5f, 0.5f, 0.5f}; // axis k of the splat is axis k + 1 of the world
        memcpy(model.groups[GSF__QUATS].value + 4 * i, quat, sizeof quat);
        for (int a = 0; a < 3; a++) model.groups[GSF__SCALES].value[3 * i + (size_t)a] = 0.3f * (float)a;
        memset(model.groups[GSF__MEANS].value + 3 * i, 0, 3 * sizeof(float));
        model.groups[GSF__OPACITY].value[i] = i % 2 ? -20.0f : 0.0f;
    }
    gsf__noise_job job = {&model, 3, gsf__stream(GSF__STREAM_NOISE, 7), 0.1};
    gsf__parallel_for(ctx, gsf__model_chunks(COUNT), gsf__noise_chunk, &job);
    for (size_t i = 0; i < 3 * COUNT; i++) {
        const double moved = (double)model.groups[GSF__MEANS].value[i];
        if (i / 3 % 2 == 0) CHECK(moved == 0.0);
        square[i % 3] += moved * moved / (COUNT / 2);
    }
    for (int a = 0; a < 3; a++) {
        const double sigma = exp(0.3 * a), factor = 1.0 / (1.0 + exp(-0.5));
        CHECK_NEAR(sqrt(square[(a + 1) % 3]) / (0.1 * factor * sigma * sigma), 1.0, 0.06);
    }
    gsf__model_destroy(ctx, &model);
}

// ---- a scene to train on -----------------------------------------------------------

typedef struct small_scene {
    gsf_splats truth, start;
    gsf_train_view views[SCENE_VIEWS + 2];  // the last two: restored views, of another size, with weights
    float* pixels[SCENE_VIEWS + 2];
    float* weights;
} small_scene;

// 4 from the origin, facing it.
static gsf_camera make_camera(double angle, double tilt, int32_t width, int32_t height) {
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    const double c = cos(angle), s = sin(angle), ct = cos(tilt), st = sin(tilt);
    const double right[3] = {c, 0, -s}, down[3] = {s * st, ct, c * st}, forward[3] = {s * ct, -st, c * ct};
    for (int k = 0; k < 3; k++) {
        camera.w2c[4 * k] = right[k];
        camera.w2c[4 * k + 1] = down[k];
        camera.w2c[4 * k + 2] = forward[k];
    }
    camera.w2c[14] = 4.0;
    camera.w2c[15] = 1.0;
    camera.width = width;
    camera.height = height;
    camera.fx = camera.fy = width;
    camera.cx = width / 2.0;
    camera.cy = height / 2.0;
    return camera;
}

static void render_to(gsf_context* ctx, const gsf_splats* splats, const gsf_camera* camera, float* pixels) {
    gsf_rasterizer* rasterizer;
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(pixels, GSF_F32, camera->width, camera->height, 3);
    CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &rasterizer));
    CHECK_OK(ctx, gsf_splat_render(ctx, rasterizer, splats, camera, NULL, &out));
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
}

// Five copies render like the splat they share: in the centre, and along the row through it. (Each ends at 3 sigma.)
static void test_mcmc_render(gsf_context* ctx) {
    static float one[WIDTH * HEIGHT * 3], five[WIDTH * HEIGHT * 3];
    const gsf_camera camera = make_camera(0.0, 0.0, WIDTH, HEIGHT);
    gsf_splats splats;
    if (!CHECK_OK(ctx, gsf_splat_make(ctx, 5, 0, &splats))) return;
    for (size_t i = 0; i < 5; i++) {
        for (size_t a = 0; a < 3; a++) {
            splats.sh[3 * i + a] = 0.5f / 0.2820948f; // white
            splats.log_scales[3 * i + a] = logf(0.4f);
        }
        splats.quats[4 * i] = 1.0f;
        splats.opacity_logits[i] = logf(0.85f / 0.15f);
    }
    splats.count = 1;
    render_to(ctx, &splats, &camera, one);
    splats.count = 5;
    double opacity;
    const double factor = gsf__mcmc_share(0.15, 5, &opacity);
    for (size_t i = 0; i < 5; i++) {
        splats.opacity_logits[i] = (float)log(opacity / (1.0 - opacity));
        for (size_t a = 0; a < 3; a++) splats.log_scales[3 * i + a] += (float)log(factor);
    }
    render_to(ctx, &splats, &camera, five);
    double row[2] = {0, 0};
    const size_t middle = (size_t)(HEIGHT / 2) * WIDTH;
    for (size_t x = 0; x < WIDTH; x++) {
        row[0] += (double)one[3 * (middle + x)];
        row[1] += (double)five[3 * (middle + x)];
    }
    CHECK(one[3 * (middle + WIDTH / 2)] > 0.8f);
    CHECK_NEAR(five[3 * (middle + WIDTH / 2)], one[3 * (middle + WIDTH / 2)], 0.01);
    CHECK_NEAR(row[1] / row[0], 1.0, 0.02);
    gsf_splat_destroy(ctx, &splats);
}

static small_scene make_small_scene(gsf_context* ctx) {
    small_scene s;
    memset(&s, 0, sizeof s);
    uint64_t state = 11;
    CHECK_OK(ctx, gsf_splat_make(ctx, SPLATS, 1, &s.truth));
    CHECK_OK(ctx, gsf_splat_make(ctx, SPLATS, 1, &s.start));
    for (int i = 0; i < SPLATS; i++) {
        for (int a = 0; a < 3; a++) {
            s.truth.means[3 * i + a] = (float)test_random_in(&state, -1, 1);
            s.truth.log_scales[3 * i + a] = (float)test_random_in(&state, -2.5, -1.2);
            s.truth.sh[12 * i + a] = (float)test_random_in(&state, -1.5, 1.5);
            for (int k = 1; k < 4; k++) s.truth.sh[12 * i + 3 * k + a] = (float)test_random_in(&state, -0.3, 0.3);
            s.start.means[3 * i + a] = s.truth.means[3 * i + a] + (float)test_random_in(&state, -0.06, 0.06);
            s.start.log_scales[3 * i + a] = s.truth.log_scales[3 * i + a] + (float)test_random_in(&state, -0.3, 0.3);
            s.start.sh[12 * i + a] = s.truth.sh[12 * i + a] * 0.5f;
        }
        for (int a = 0; a < 4; a++)
            s.truth.quats[4 * i + a] = s.start.quats[4 * i + a] = (float)test_random_in(&state, -1, 1);
        s.truth.opacity_logits[i] = (float)test_random_in(&state, 0, 3);
        s.start.opacity_logits[i] = 0.0f;
        s.start.ids[i] = (uint32_t)(1000 + 3 * i);
    }
    s.weights = (float*)malloc(40 * 40 * sizeof(float));
    for (int i = 0; i < 40 * 40; i++) s.weights[i] = (float)(i % 11) / 10.0f;
    for (int v = 0; v < SCENE_VIEWS + 2; v++) {
        gsf_train_view* view = &s.views[v];
        view->camera = v < SCENE_VIEWS ? make_camera(0.5 * (v - 2), 0.1 * v, WIDTH, HEIGHT)
                                 : make_camera(1.4, 0.3 * (v - SCENE_VIEWS), 40, 33 + v - SCENE_VIEWS);
        s.pixels[v] = (float*)malloc((size_t)(view->camera.width * view->camera.height) * 3 * sizeof(float));
        render_to(ctx, &s.truth, &view->camera, s.pixels[v]);
        view->image = gsf_wrap_image(s.pixels[v], GSF_F32, view->camera.width, view->camera.height, 3);
        if (v >= SCENE_VIEWS) view->weight = gsf_wrap_image(s.weights, GSF_F32, 40, view->camera.height, 1);
    }
    return s;
}

// The pixels in the left half are garbage with weight zero: their values change no bit, and the rest is learned as if
// the photos were smaller. Byte weights give the same result as float weights.
static void test_masked_training(gsf_context* ctx, const small_scene* s) {
    enum { PIXELS = WIDTH * HEIGHT };
    static float photos[SCENE_VIEWS][3 * PIXELS], shown[3 * PIXELS], weight[PIXELS];
    static uint8_t bytes[PIXELS];
    gsf_train_view views[SCENE_VIEWS];
    gsf_splats made[3];
    double error[3] = {0.0};
    for (int i = 0; i < PIXELS; i++) weight[i] = (float)(bytes[i] = i % WIDTH < WIDTH / 2 ? 0 : i % 7 ? 255 : 51) / 255.0f;
    for (int run = 0; run < 3; run++) { // green, noise with weights in floats, green without weights
        uint64_t state = 3;
        for (int v = 0; v < SCENE_VIEWS; v++) {
            views[v] = s->views[v];
            for (int i = 0; i < 3 * PIXELS; i++)
                photos[v][i] = i / 3 % WIDTH >= WIDTH / 2 ? s->pixels[v][i]
                               : run == 1                 ? (float)test_random(&state)
                                                          : (float)(i % 3 == 1);
            views[v].image = gsf_wrap_image(photos[v], GSF_F32, WIDTH, HEIGHT, 3);
            if (run == 1) views[v].weight = gsf_wrap_image(weight, GSF_F32, WIDTH, HEIGHT, 1);
            if (run == 0) views[v].weight = gsf_wrap_image(bytes, GSF_U8, WIDTH, HEIGHT, 1);
        }
        gsf_train_desc desc = {0};
        desc.iterations = 150;
        desc.depth_smoothness = 0.01f;
        gsf_trainer* trainer;
        if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, views, SCENE_VIEWS, &s->start, &trainer))) return;
        for (int i = 0; i < desc.iterations; i++) CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, NULL));
        CHECK_OK(ctx, gsf_splat_copy_trained(ctx, trainer, &made[run]));
        gsf_splat_destroy_trainer(ctx, trainer);
        render_to(ctx, &made[run], &views[0].camera, shown);
        for (int i = 0; i < 3 * PIXELS; i++)
            if (i / 3 % WIDTH >= WIDTH / 2) error[run] += fabs((double)shown[i] - (double)s->pixels[0][i]) / (1.5 * PIXELS);
    }
    CHECK(made[0].count == made[1].count && made[0].count > 0);
    if (made[0].count == made[1].count) {
        CHECK(memcmp(made[0].means, made[1].means, 3 * made[0].count * sizeof(float)) == 0);
        CHECK(memcmp(made[0].sh, made[1].sh, 12 * made[0].count * sizeof(float)) == 0);
    }
    CHECK(error[0] < 0.02 && error[0] < error[2]);
    printf("masked training: error %.4f, %.4f without masks\n", error[0], error[2]);
    for (int run = 0; run < 3; run++) gsf_splat_destroy(ctx, &made[run]);
}

// The grey of the photos' mean, by their weights, is the background of trainer, renders and trained splats; of random ones the
// given colour is.
static void test_trainer_background(gsf_context* ctx, const small_scene* s) {
    enum { PIXELS = WIDTH * HEIGHT };
    static float shown[3 * PIXELS], weight[PIXELS];
    static const gsf_background kinds[] = {GSF_BACKGROUND_GIVEN, GSF_BACKGROUND_PHOTOS, GSF_BACKGROUND_RANDOM};
    static const float given[3] = {0.25f, 0.5f, 0.75f};
    gsf_train_view views[2] = {s->views[0], s->views[1]};
    double sum = 0.0, total = 3.0 * PIXELS;
    views[1].weight = gsf_wrap_image(weight, GSF_F32, WIDTH, HEIGHT, 1);
    for (int i = 0; i < PIXELS; i++) {
        weight[i] = (float)(i % 3) * 0.5f;
        total += 3.0 * (double)weight[i];
        for (int c = 0; c < 3; c++)
            sum += (double)s->pixels[0][3 * i + c] + (double)weight[i] * (double)s->pixels[1][3 * i + c];
    }
    gsf_camera away = make_camera(3.1415926, 0.0, WIDTH, HEIGHT); // behind the splats, looking away
    away.w2c[14] = -20.0;
    for (int k = 0; k < 3; k++) {
        gsf_trainer* trainer;
        gsf_train_desc desc = {0};
        gsf_splats made;
        gsf_render_output out = {0};
        desc.iterations = 30;
        desc.background_kind = kinds[k];
        memcpy(desc.background, given, sizeof given);
        if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, views, 2, &s->start, &trainer))) return;
        for (int i = 0; i < 3; i++) CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, NULL));
        CHECK_OK(ctx, gsf_splat_copy_trained(ctx, trainer, &made));
        out.color = gsf_wrap_image(shown, GSF_F32, WIDTH, HEIGHT, 3);
        CHECK_OK(ctx, gsf_splat_render_trainer(ctx, trainer, &away, &out));
        const gsf_train_desc used = gsf_splat_get_trainer_desc(trainer);
        for (int c = 0; c < 3; c++) {
            const double expected = kinds[k] == GSF_BACKGROUND_PHOTOS ? sum / total : (double)given[c];
            CHECK_NEAR(used.background[c], expected, 1e-6);
            CHECK(made.background[c] == used.background[c] && shown[c] == used.background[c]);
        }
        gsf_splat_destroy(ctx, &made);
        gsf_splat_destroy_trainer(ctx, trainer);
    }
}

static void destroy_scene(gsf_context* ctx, small_scene* s) {
    gsf_splat_destroy(ctx, &s->truth);
    gsf_splat_destroy(ctx, &s->start);
    free(s->weights);
    for (int v = 0; v < SCENE_VIEWS + 2; v++) free(s->pixels[v]);
}

// Densifies, resets and uses every regulariser within 60 iterations.
static gsf_train_desc make_busy_desc(void) {
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 60;
    desc.seed = 42;
    desc.sh_interval = 15;
    desc.densify_from = 5;
    desc.densify_until = 50;
    desc.densify_interval = 10;
    desc.densify_grad = 5e-4f;
    desc.opacity_reset_interval = 25;
    desc.prune_opacity = 0.006f;
    desc.dropout = 0.2f;
    desc.opacity_decay = 0.002f;
    desc.scale_penalty = 0.01f;
    desc.depth_smoothness = 0.01f;
    desc.background[1] = 0.2f;
    desc.coarse_until = 12;
    desc.sharpness = 0.5f;
    desc.sharpness_from = 40;
    return desc;
}

static gsf_train_desc busy_mcmc_desc(void) { // relocates, grows to its budget and adds noise
    gsf_train_desc desc = make_busy_desc();
    desc.mcmc = 1;
    desc.max_splats = SPLATS + 8;
    desc.prune_opacity = 0.3f;
    return desc;
}

static gsf_trainer* make_busy(gsf_context* ctx, const small_scene* s, int mcmc) {
    gsf_train_desc desc = mcmc ? busy_mcmc_desc() : make_busy_desc();
    gsf_trainer* trainer = NULL;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer))) exit(2);
    CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, s->views + SCENE_VIEWS, 2));
    gsf_splat_set_restored_weight(trainer, 0.5f);
    return trainer;
}

static gsf_buffer save_state(gsf_context* ctx, const gsf_trainer* trainer) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_splat_format_trainer(ctx, trainer, &text);
    gsf_append_last_chunk(ctx, &text);
    CHECK(!text.failed);
    return text;
}

static int same_text(const gsf_buffer* a, const gsf_buffer* b) {
    return a->size == b->size && memcmp(a->data, b->data, a->size) == 0;
}

static void take_steps(gsf_context* ctx, gsf_trainer* trainer, int steps) {
    for (int i = 0; i < steps; i++)
        if (!CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, NULL))) return;
}

// ---- learning ----------------------------------------------------------------------

static double mean_square_error(gsf_context* ctx, gsf_trainer* trainer, const small_scene* s) {
    double sum = 0.0;
    static float pixels[WIDTH * HEIGHT * 3];
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(pixels, GSF_F32, WIDTH, HEIGHT, 3);
    for (int v = 0; v < SCENE_VIEWS; v++) {
        CHECK_OK(ctx, gsf_splat_render_trainer(ctx, trainer, &s->views[v].camera, &out));
        for (int i = 0; i < WIDTH * HEIGHT * 3; i++) {
            const double d = (double)pixels[i] - (double)s->pixels[v][i];
            sum += d * d / (WIDTH * HEIGHT * 3 * SCENE_VIEWS);
        }
    }
    return sum;
}

static void test_learns(gsf_context* ctx, const small_scene* s) {
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 300;
    desc.densify_until = -1;
    gsf_trainer* trainer;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer))) return;
    const double before = mean_square_error(ctx, trainer, s);
    double first = 0.0, last = 0.0;
    for (int i = 0; i < 300; i++) {
        gsf_train_stats stats;
        if (!CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, &stats))) break;
        CHECK(stats.iteration == i + 1 && stats.splats == SPLATS && stats.rejected == 0 && stats.restored_loss == 0.0);
        CHECK_NEAR(stats.loss, 0.8 * stats.l1 + 0.2 * (1.0 - stats.ssim), 1e-7);
        if (i < SCENE_VIEWS) first += stats.loss;
        if (i >= 300 - SCENE_VIEWS) last += stats.loss;
    }
    const double after = mean_square_error(ctx, trainer, s);
    printf("learning (%s): loss %.4f -> %.4f, %.2f -> %.2f dB\n", gsf_describe_cpu_level(ctx->cpu_level), first / SCENE_VIEWS,
           last / SCENE_VIEWS, -10.0 * log10(before), -10.0 * log10(after));
    CHECK(last < 0.25 * first);
    CHECK(after < before * 0.1); // 10 dB
    gsf_train_stats stats;
    CHECK_RESULT(ctx, gsf_splat_step_trainer(ctx, trainer, &stats), GSF_ERROR_INVALID_ARGUMENT);
    gsf_splats copy;
    CHECK_OK(ctx, gsf_splat_copy_trained(ctx, trainer, &copy));
    const gsf_splats* view = gsf_splat_get_trained(trainer);
    CHECK(copy.count == view->count && memcmp(copy.means, view->means, 3 * copy.count * sizeof(float)) == 0 &&
          memcmp(copy.ids, s->start.ids, copy.count * sizeof(uint32_t)) == 0);
    gsf_splat_destroy(ctx, &copy);
    gsf_splat_destroy_trainer(ctx, trainer);
}

// A third of the splats start where no camera sees them, too faint to learn.
static void test_mcmc_learns(gsf_context* ctx, const small_scene* s) {
    enum { BUDGET = SPLATS + 11 };
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 300;
    desc.mcmc = 1;
    desc.max_splats = BUDGET;
    desc.densify_interval = 20;
    gsf_splats start;
    if (!CHECK_OK(ctx, gsf_splat_make(ctx, SPLATS, 1, &start))) return;
    memcpy(start.means, s->start.means, SPLATS * (3 + 3 + 4 + 1 + 12) * sizeof(float)); // one block, see gsf_splat_make
    for (size_t i = 0; i < SPLATS; i += 3) start.opacity_logits[i] = -12.0f;
    gsf_trainer* trainer;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &start, &trainer))) return;
    const double before = mean_square_error(ctx, trainer, s);
    double first = 0.0, last = 0.0;
    for (int i = 0; i < 300; i++) {
        gsf_train_stats stats;
        if (!CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, &stats))) break;
        CHECK(stats.splats >= SPLATS && stats.splats <= BUDGET && stats.rejected == 0);
        if (i < SCENE_VIEWS) first += stats.loss;
        if (i >= 300 - SCENE_VIEWS) last += stats.loss;
    }
    const double after = mean_square_error(ctx, trainer, s);
    const gsf_splats* end = gsf_splat_get_trained(trainer);
    size_t faint = 0;
    for (size_t i = 0; i < end->count; i++) faint += end->opacity_logits[i] < -5.0f;
    printf("MCMC (%s): loss %.4f -> %.4f, %.2f -> %.2f dB, %zu faint\n", gsf_describe_cpu_level(ctx->cpu_level),
           first / SCENE_VIEWS, last / SCENE_VIEWS, -10.0 * log10(before), -10.0 * log10(after), faint);
    CHECK(end->count == BUDGET && faint < SPLATS / 12);
    CHECK(last < 0.4 * first);
    CHECK(after < before * 0.2); // 7 dB
    gsf_splat_destroy_trainer(ctx, trainer);
    gsf_splat_destroy(ctx, &start);
}

// The candidates that are counted before a visit, for which a step reserves memory, are those selected after it.
static void test_candidates(gsf_context* ctx, const small_scene* s) {
    gsf_trainer* trainer = make_busy(ctx, s, 0);
    gsf__model* model = &trainer->model;
    for (int i = 0; i < 9; i++) CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, NULL));
    gsf__densify_rule rule = gsf__trainer_rule(trainer, 10);
    rule.max_splats = 3 * model->count;
    float sum = 0.0f;
    for (size_t i = 0; i < model->count; i++) sum += gsf__densify_mean_grad(model, i);
    rule.grad = sum / (float)model->count; // some splats reach the mean, some do not
    gsf__visit_job visits;
    memset(&visits, 0, sizeof visits);
    visits.model = model;
    for (int k = 0; k < 2; k++) {
        visits.counts[k] = 1;
        visits.half[k][0] = 100.0f;
        visits.half[k][1] = 80.0f;
    }
    for (size_t i = 0; i < model->count; i++)
        for (int k = 0; k < 2; k++) {
            model->seen[k][i] = (i + (size_t)k) % 3 == 0;
            model->screen[k][2 * i] = i % 50 == 0 ? NAN : (float)(1e-4 * gsf_draw_uniform(1, (uint64_t)k, i));
        }
    const size_t found = gsf__visit_candidates(&visits, rule.grad);
    size_t clones, splits;
    for (size_t c = 0; c < gsf__model_chunks(model->count); c++) gsf__visit_chunk(&visits, c, 0);
    gsf__densify_select(model, &rule, &clones, &splits);
    CHECK(found == clones + splits && found > 0 && found < model->count);
    gsf_splat_destroy_trainer(ctx, trainer);
}

// Each photo is used once per permutation; each render counts as one visit.
static void test_order_and_visits(gsf_context* ctx, const small_scene* s) {
    gsf_train_desc desc = make_busy_desc();
    desc.densify_from = 1000;
    desc.dropout = 0.0f;
    gsf_trainer* trainer;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer))) return;
    int seen[4][SCENE_VIEWS] = {{0}}, differ = 0;
    for (uint64_t step = 0; step < 4 * SCENE_VIEWS; step++)
        seen[step / SCENE_VIEWS][gsf__photo_at(&trainer->photos, 1, GSF__STREAM_PHOTOS, step) - trainer->photos.photos]++;
    for (int round = 0; round < 4; round++)
        for (int v = 0; v < SCENE_VIEWS; v++) CHECK(seen[round][v] == 1);
    for (uint64_t step = 0; step < SCENE_VIEWS; step++)
        differ += gsf__photo_at(&trainer->photos, 1, GSF__STREAM_PHOTOS, step) !=
                  gsf__photo_at(&trainer->photos, 1, GSF__STREAM_PHOTOS, step + SCENE_VIEWS);
    CHECK(differ > 0);

    take_steps(ctx, trainer, 3);
    size_t three = 0;
    for (size_t i = 0; i < trainer->model.count; i++) three += trainer->model.visits[0][i] == 3;
    CHECK(three == SPLATS); // all are visible in all cameras
    CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, s->views + SCENE_VIEWS, 2));
    gsf_splat_set_restored_weight(trainer, 0.0f);
    take_steps(ctx, trainer, 1);
    gsf_splat_set_restored_weight(trainer, 1.0f);
    gsf_train_stats stats;
    CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, &stats));
    CHECK(stats.restored_loss > 0.0);
    size_t six = 0;
    for (size_t i = 0; i < trainer->model.count; i++)
        six += trainer->model.visits[0][i] == 5 && trainer->model.visits[1][i] == 1;
    CHECK(six == SPLATS);
    CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, NULL, 0));
    CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, &stats));
    CHECK(stats.restored_loss == 0.0);
    gsf_splat_destroy_trainer(ctx, trainer);
}

// The gradient of a restored view is that of the same photo times lambda. The first step's statistic is the norm of the
// gradient from the backward pass of the same image; without cancellation it is never smaller, and for most splats
// larger.
static void test_absolute_statistic(gsf_context* ctx, const small_scene* s) {
    float sums[2][SPLATS];
    for (int absolute = 0; absolute < 2; absolute++) {
        gsf_train_desc desc = make_busy_desc();
        desc.densify_absolute = absolute;
        desc.dropout = 0.0f;
        gsf_trainer* trainer;
        if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer))) return;
        take_steps(ctx, trainer, 1);
        CHECK(trainer->model.count == SPLATS);
        memcpy(sums[absolute], trainer->model.grad_sum[0], sizeof sums[absolute]);
        gsf_splat_destroy_trainer(ctx, trainer);
    }
    int smaller = 0, larger = 0;
    for (int i = 0; i < SPLATS; i++) {
        smaller += sums[1][i] < 0.9999f * sums[0][i];
        larger += sums[1][i] > 1.05f * sums[0][i];
    }
    CHECK(smaller == 0 && larger > SPLATS / 2);
}

static void test_restored_gradient(gsf_context* ctx, const small_scene* s) {
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 10;
    gsf_trainer *both, *one;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &both));
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &one));
    CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, both, s->views, 1));
    gsf_splat_set_restored_weight(both, 2.0f);
    gsf__visit_job visits;
    gsf_train_stats stats;
    memset(&visits, 0, sizeof visits);
    CHECK_OK(ctx, gsf__trainer_gradients(ctx, both, 1, &visits, &stats));
    CHECK(visits.counts[0] && visits.counts[1] && stats.loss == stats.restored_loss);
    memset(&visits, 0, sizeof visits);
    CHECK_OK(ctx, gsf__trainer_gradients(ctx, one, 1, &visits, &stats));
    CHECK(visits.counts[0] && !visits.counts[1]);
    for (int g = 0; g < GSF__GROUPS; g++) {
        size_t wrong = 0;
        double largest = 0.0;
        const size_t n = one->model.count * one->model.groups[g].width;
        for (size_t i = 0; i < n; i++) largest = fmax(largest, fabs((double)one->model.groups[g].grad[i]));
        for (size_t i = 0; i < n; i++)
            wrong += !(fabs((double)both->model.groups[g].grad[i] - 3.0 * (double)one->model.groups[g].grad[i]) <=
                       1e-5 * largest);
        CHECK(wrong == 0 && largest > 0.0);
    }
    CHECK(memcmp(both->model.screen[0], one->model.screen[0], 2 * SPLATS * sizeof(float)) == 0);
    gsf_splat_destroy_trainer(ctx, both);
    gsf_splat_destroy_trainer(ctx, one);
}

// Halved photos are means of 2 x 2 pixels by their weights, seen by a camera that projects to half the coordinates; they are
// trained on up to coarse_until and no longer.
static void test_coarse(gsf_context* ctx, const small_scene* s) {
    gsf_train_desc desc = make_busy_desc();
    gsf_trainer *coarse, *full;
    gsf_train_stats a, b;
    desc.coarse_until = 2;
    gsf_train_view views[2] = {s->views[0], s->views[1]};
    static float weights[WIDTH * HEIGHT];
    for (size_t i = 0; i < WIDTH * HEIGHT; i++) weights[i] = (float)(i * 7 % 5) / 4.0f;
    views[1].weight = gsf_wrap_image(weights, GSF_F32, WIDTH, HEIGHT, 1);
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, views, 2, &s->start, &coarse));
    desc.coarse_until = 0;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, views, 2, &s->start, &full));
    CHECK(coarse->coarse.count == 2 && full->coarse.count == 0);
    for (size_t v = 0; v < 2; v++) {
        const gsf__photo *small = coarse->coarse.photos + v, *photo = coarse->photos.photos + v;
        const size_t width = (size_t)small->camera.width, height = (size_t)small->camera.height;
        const double point[3] = {0.1, -0.2, 0.3};
        double x = 0.0, y = 0.0, z, half_x = -1.0, half_y = -1.0, half_z;
        CHECK(width == WIDTH / 2 && height == HEIGHT / 2 && small->target.width == WIDTH / 2);
        CHECK(gsf_project_point(&photo->camera, point, &x, &y, &z) &&
              gsf_project_point(&small->camera, point, &half_x, &half_y, &half_z));
        CHECK_NEAR(half_x, 0.5 * x, 1e-12);
        CHECK_NEAR(half_y, 0.5 * y, 1e-12);
        double worst = 0.0;
        for (size_t i = 0; i < width * height; i++) {
            double total = 0.0, sum[3] = {0.0, 0.0, 0.0};
            for (size_t k = 0; k < 4; k++) {
                const size_t at = (2 * (i / width) + k / 2) * WIDTH + 2 * (i % width) + k % 2;
                const double w = photo->target.weight ? (double)photo->target.weight[at] : 1.0;
                total += w;
                for (size_t c = 0; c < 3; c++) sum[c] += w * (double)photo->target.f32[3 * at + c];
            }
            for (size_t c = 0; c < 3; c++)
                worst = fmax(worst, fabs((double)small->target.f32[3 * i + c] - (total > 0.0 ? sum[c] / total : 0.0)));
            if (small->target.weight) worst = fmax(worst, fabs((double)small->target.weight[i] - 0.25 * total));
        }
        CHECK(worst < 1e-6);
    }
    for (int i = 0; i < 2; i++) CHECK_OK(ctx, gsf_splat_step_trainer(ctx, coarse, &a));
    take_steps(ctx, full, 2);
    gsf_buffer state = save_state(ctx, coarse); // from here on they train alike
    CHECK_OK(ctx, gsf_splat_parse_trainer(ctx, full, "state", state.data, state.size));
    for (int i = 0; i < 3; i++) {
        CHECK_OK(ctx, gsf_splat_step_trainer(ctx, coarse, &a));
        CHECK_OK(ctx, gsf_splat_step_trainer(ctx, full, &b));
        CHECK(a.loss == b.loss);
    }
    gsf_destroy_buffer(ctx, &state);
    gsf_splat_destroy_trainer(ctx, coarse);
    gsf_splat_destroy_trainer(ctx, full);
}

// The gradient of a sharpness-aware step is the mean of those before and after means are moved by so many pixels up the loss.
static void test_sharpness(gsf_context* ctx, const small_scene* s) {
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 100;
    desc.seed = 3;
    gsf_trainer *plain, *sharp;
    gsf__visit_job visits;
    gsf_train_stats a, b;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &plain));
    desc.sharpness = 2.0f;
    desc.sharpness_from = -1;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &sharp));
    CHECK(plain->desc.sharpness_from == 75 && sharp->desc.sharpness_from == 0);
    memset(&visits, 0, sizeof visits);
    CHECK_OK(ctx, gsf__trainer_gradients(ctx, sharp, 1, &visits, &a));
    CHECK(memcmp(sharp->model.groups[GSF__MEANS].value, plain->model.groups[GSF__MEANS].value, 12 * SPLATS) == 0);
    CHECK_OK(ctx, gsf__trainer_gradients(ctx, plain, 1, &visits, &b));
    CHECK(a.loss == b.loss);
    float before[3 * SPLATS], *means = plain->model.groups[GSF__MEANS].value, *slopes = plain->model.groups[GSF__MEANS].grad;
    double largest = 0.0, worst = 0.0;
    memcpy(before, slopes, sizeof before);
    for (size_t i = 0; i < SPLATS; i++) {
        const float* g = slopes + 3 * i;
        const double norm = sqrt((double)g[0] * g[0] + (double)g[1] * g[1] + (double)g[2] * g[2]);
        double point[3], x, y, depth;
        for (size_t k = 0; k < 3; k++) point[k] = plain->view.origin[k] + (double)means[3 * i + k];
        if (!(norm > 0.0) || !gsf_project_point(&s->views[0].camera, point, &x, &y, &depth)) continue;
        const double step = 2.0 * depth / s->views[0].camera.fx / norm;
        for (size_t k = 0; k < 3; k++) means[3 * i + k] += (float)(step * (double)g[k]);
    }
    gsf__trainer_clear_gradients(plain);
    CHECK_OK(ctx, gsf__trainer_gradients(ctx, plain, 1, &visits, &b));
    for (size_t i = 0; i < 3 * SPLATS; i++) {
        const double mean = 0.5 * ((double)before[i] + (double)slopes[i]);
        largest = fmax(largest, fabs(mean));
        worst = fmax(worst, fabs((double)sharp->model.groups[GSF__MEANS].grad[i] - mean));
    }
    CHECK(b.loss > a.loss && largest > 0.0 && worst < 1e-4 * largest);
    gsf_splat_destroy_trainer(ctx, plain);
    gsf_splat_destroy_trainer(ctx, sharp);
}

// A negative learning rate means 0: that parameter keeps its values, all others learn. lazy: the SH catch up with rates
// of 0.
static void test_zero_rates(gsf_context* ctx, const small_scene* s, int lazy) {
    for (int rate = 0; rate < 6; rate++) {
        gsf_train_desc desc = make_busy_desc();
        gsf_trainer* trainer;
        desc.densify_until = -1;
        desc.dropout = desc.opacity_decay = 0.0f;
        desc.lazy_adam = lazy;
        float* const rates[6] = {&desc.lr_means,   &desc.lr_scales, &desc.lr_quats,
                                 &desc.lr_opacity, &desc.lr_sh_dc,  &desc.lr_sh_rest};
        *rates[rate] = -1.0f;
        CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer));
        const float resolved[6] = {trainer->desc.lr_means,   trainer->desc.lr_scales, trainer->desc.lr_quats,
                                   trainer->desc.lr_opacity, trainer->desc.lr_sh_dc,  trainer->desc.lr_sh_rest};
        for (int k = 0; k < 6; k++) CHECK((resolved[k] == 0.0f) == (k == rate));
        take_steps(ctx, trainer, 30);
        const gsf_splats *now = gsf_splat_get_trained(trainer), *was = &s->start;
        const size_t n = was->count, row = 3 * (size_t)gsf_splat_count_sh(was->sh_degree);
        int dc = 0, rest = 0; // floats that changed
        for (size_t i = 0; i < n * row; i++) *(i % row < 3 ? &dc : &rest) += now->sh[i] != was->sh[i];
        CHECK(now->count == n && row > 3);
        CHECK((memcmp(now->means, was->means, 3 * n * sizeof(float)) == 0) == (rate == 0));
        CHECK((memcmp(now->log_scales, was->log_scales, 3 * n * sizeof(float)) == 0) == (rate == 1));
        CHECK((memcmp(now->quats, was->quats, 4 * n * sizeof(float)) == 0) == (rate == 2));
        CHECK((memcmp(now->opacity_logits, was->opacity_logits, n * sizeof(float)) == 0) == (rate == 3));
        CHECK((dc == 0) == (rate == 4) && (rest == 0) == (rate == 5));
        gsf_splat_destroy_trainer(ctx, trainer);
    }
}

// Linear images are encoded as sRGB: known pairs, and a round trip of all 8-bit values.
static void test_linear_photos(gsf_context* ctx, const small_scene* s) {
    enum { N = 3 * WIDTH * HEIGHT };
    static const float known[6][2] = {{0.0f, 0.0f}, {0.002f, 0.02584f}, {0.0031308f, 0.04045f},
                                      {0.2140411f, 0.5f}, {1.0f, 1.0f}, {-0.1f, -1.292f}};
    static uint8_t bytes[N];
    static float floats[N];
    for (size_t i = 0; i < N; i++) {
        bytes[i] = (uint8_t)(i * 7 + i / 256);
        floats[i] = i < 6 ? known[i][0] : (float)bytes[i] / 255.0f;
    }
    gsf_train_view views[2] = {s->views[0], s->views[1]};
    gsf_trainer* trainer;
    views[0].image = gsf_wrap_image(bytes, GSF_U8, WIDTH, HEIGHT, 3);
    views[1].image = gsf_wrap_image(floats, GSF_F32, WIDTH, HEIGHT, 3);
    views[0].image.color_space = views[1].image.color_space = GSF_COLOR_LINEAR;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, NULL, views, 2, &s->start, &trainer));
    const float *a = trainer->photos.photos[0].target.f32, *b = trainer->photos.photos[1].target.f32;
    CHECK(a && b && !trainer->photos.photos[0].target.u8);
    for (int i = 0; i < 6; i++) CHECK_NEAR(b[i], known[i][1], 1e-6);
    for (size_t i = 6; i < N; i++) {
        const double v = (double)b[i], back = v <= 0.04045 ? v / 12.92 : pow((v + 0.055) / 1.055, 2.4);
        CHECK_NEAR(back, bytes[i] / 255.0, 1e-6);
        CHECK(a[i] == b[i]);
    }
    gsf_splat_destroy_trainer(ctx, trainer);
    floats[9] = INFINITY;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, NULL, views, 2, &s->start, &trainer), GSF_ERROR_NUMERIC);
}

static void test_settings(gsf_context* ctx, const small_scene* s) {
    gsf_trainer* trainer;
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, NULL, s->views, SCENE_VIEWS, &s->start, &trainer));
    CHECK(trainer->desc.iterations == 30000 && trainer->desc.densify_until == 15000 &&
          trainer->desc.densify_from == 500);
    CHECK(trainer->desc.opacity_reset_interval == 3000 && trainer->desc.sh_interval == 1000);
    CHECK(trainer->first_bands == 1 && gsf__trainer_bands(trainer, 999) == 1 &&
          gsf__trainer_bands(trainer, 1000) == 2 && gsf__trainer_bands(trainer, 5000) == 2);
    // five cameras 4 from the origin
    double centers[SCENE_VIEWS][3], mean[3] = {0, 0, 0}, extent = 0.0;
    for (int v = 0; v < SCENE_VIEWS; v++) gsf_get_camera_center(&s->views[v].camera, centers[v]);
    for (int v = 0; v < SCENE_VIEWS; v++) for (int a = 0; a < 3; a++) mean[a] += centers[v][a] / SCENE_VIEWS;
    for (int v = 0; v < SCENE_VIEWS; v++)
        extent = fmax(extent, 1.1 * sqrt(pow(centers[v][0] - mean[0], 2) + pow(centers[v][1] - mean[1], 2) +
                                         pow(centers[v][2] - mean[2], 2)));
    CHECK_NEAR(trainer->desc.extent, extent, 1e-6);
    CHECK_NEAR(trainer->desc.render.near_plane, 0.01 * extent, 1e-6);
    gsf_splat_destroy_trainer(ctx, trainer);

    desc.iterations = 3000;
    desc.render.near_plane = 0.7f;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &trainer)); // one camera: median depth
    CHECK(trainer->desc.densify_until == 1500 && trainer->desc.densify_from == 50 && trainer->desc.sh_interval == 100);
    CHECK(trainer->desc.opacity_reset_interval == 1000 && trainer->desc.densify_interval == 100);
    CHECK(trainer->desc.render.near_plane == 0.7f);
    CHECK_NEAR(trainer->desc.extent, 4.0, 0.4);
    CHECK(trainer->desc.mcmc_noise == 0.0f && trainer->desc.opacity_penalty == 0.0f);
    gsf_splat_destroy_trainer(ctx, trainer);

    gsf_train_desc zeros = desc;
    zeros.lambda_ssim = zeros.densify_grad = zeros.densify_scale = zeros.prune_opacity = -1.0f;
    zeros.densify_from = -1;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &zeros, s->views, 1, &s->start, &trainer));
    CHECK(trainer->desc.lambda_ssim == 0.0f && trainer->desc.densify_grad == 0.0f && trainer->desc.densify_scale == 0.0f);
    CHECK(trainer->desc.prune_opacity == 0.0f && trainer->desc.densify_from == 0);
    gsf_splat_destroy_trainer(ctx, trainer);
    zeros.lr_means_final = -1.0f; // decays exponentially, so it cannot be 0
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &zeros, s->views, 1, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);

    desc.mcmc = 1;
    desc.scale_penalty = -1.0f;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, &s->truth, &trainer));
    CHECK(trainer->desc.densify_until == 2500 && trainer->desc.opacity_reset_interval < 0);
    CHECK(trainer->desc.mcmc_noise == 5e5f && trainer->desc.max_splats == 1000000);
    CHECK(trainer->desc.opacity_penalty == 0.01f && trainer->desc.scale_penalty == 0.0f);
    gsf_splat_destroy_trainer(ctx, trainer);
    desc.mcmc = 0;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, &s->truth, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    desc.scale_penalty = 0.0f;

    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, &s->truth, &trainer));
    CHECK(trainer->first_bands == 2 && gsf__trainer_bands(trainer, 1) == 2); // bands in use remain in use
    gsf_splat_destroy_trainer(ctx, trainer);
    desc.sh_degree = 3;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, &s->truth, &trainer));
    CHECK(gsf_splat_get_trained(trainer)->sh_degree == 3 && trainer->first_bands == 2);
    CHECK(trainer->view.sh[48 + 11] == s->truth.sh[12 + 11] && trainer->view.sh[48 + 12] == 0.0f);
    gsf_splat_destroy_trainer(ctx, trainer);
}

// ---- determinism ---------------------------------------------------------------------

static void test_trainer_workers(const small_scene* s, gsf_cpu_level level, int mcmc) {
    gsf_buffer states[3];
    for (int run = 0; run < 3; run++) {
        int workers = run == 1 ? 2 : 5;
        gsf_context ctx = open_context(level, run ? &workers : NULL);
        gsf_trainer* trainer = make_busy(&ctx, s, mcmc);
        take_steps(&ctx, trainer, 60);
        states[run] = save_state(&ctx, trainer);
        if (run == 0) printf("busy run (%s): %zu splats, %u ids\n", gsf_describe_cpu_level(ctx.cpu_level),
                             trainer->model.count, (unsigned)trainer->model.next_id);
        if (run == 0 && !mcmc) CHECK(trainer->model.count > SPLATS + 10);
        if (run == 0 && mcmc) { // uses the whole budget; relocation assigns further ids
            CHECK(trainer->model.count == SPLATS + 8);
            CHECK(trainer->model.next_id > 1000 + 3 * (SPLATS - 1) + 1 + 8);
        }
        gsf_splat_destroy_trainer(&ctx, trainer);
    }
    CHECK(same_text(&states[0], &states[1]));
    CHECK(same_text(&states[0], &states[2]));
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    for (int run = 0; run < 3; run++) gsf_destroy_buffer(&ctx, &states[run]);
}

// ---- checkpoints -----------------------------------------------------------------------

static void test_resume(gsf_context* ctx, const small_scene* s, int mcmc) {
    static const int stops[] = {0, 1, 9, 10, 11, 25, 37, 50, 60};
    gsf_trainer* trainer = make_busy(ctx, s, mcmc);
    take_steps(ctx, trainer, 60);
    gsf_buffer whole = save_state(ctx, trainer);
    gsf_splat_destroy_trainer(ctx, trainer);
    for (size_t k = 0; k < sizeof stops / sizeof *stops; k++) {
        trainer = make_busy(ctx, s, mcmc);
        take_steps(ctx, trainer, stops[k]);
        gsf_buffer state = save_state(ctx, trainer);
        gsf_splat_destroy_trainer(ctx, trainer);
        // the caller provides views and settings again, some before and some after
        gsf_train_desc desc = mcmc ? busy_mcmc_desc() : make_busy_desc();
        if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->truth, &trainer))) exit(2);
        if (k % 2) CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, s->views + SCENE_VIEWS, 2));
        CHECK_OK(ctx, gsf_splat_parse_trainer(ctx, trainer, "state", state.data, state.size));
        if (k % 2 == 0) CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, s->views + SCENE_VIEWS, 2));
        gsf_buffer again = save_state(ctx, trainer);
        CHECK(same_text(&state, &again)); // formatting what was parsed gives the same bytes
        take_steps(ctx, trainer, 60 - stops[k]);
        gsf_buffer end = save_state(ctx, trainer);
        if (!CHECK(same_text(&whole, &end))) fprintf(stderr, "resumed at %d\n", stops[k]);
        gsf_splat_destroy_trainer(ctx, trainer);
        gsf_destroy_buffer(ctx, &state);
        gsf_destroy_buffer(ctx, &again);
        gsf_destroy_buffer(ctx, &end);
    }
    gsf_destroy_buffer(ctx, &whole);
}

static void test_damaged_checkpoints(gsf_context* ctx, const small_scene* s) {
    gsf_splats few = s->start;
    few.count = 2;
    gsf_train_desc desc = make_busy_desc();
    gsf_trainer* trainer;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &few, &trainer))) return;
    take_steps(ctx, trainer, 3);
    gsf_buffer state = save_state(ctx, trainer);
    size_t accepted = 0;
    for (size_t size = 0; size < state.size; size++) { // in buffers of the exact size
        char* cut = (char*)malloc(size ? size : 1);
        memcpy(cut, state.data, size);
        accepted += gsf_splat_parse_trainer(ctx, trainer, "cut", cut, size) == GSF_OK;
        free(cut);
    }
    CHECK(accepted == 0);
    for (size_t i = 0; i < state.size; i++) {
        state.data[i] ^= (char)(1 << i % 8);
        accepted += gsf_splat_parse_trainer(ctx, trainer, "flipped", state.data, state.size) == GSF_OK;
        state.data[i] ^= (char)(1 << i % 8);
    }
    CHECK(accepted == 0);
    gsf_buffer same = save_state(ctx, trainer);
    CHECK(same_text(&state, &same)); // untouched by the refused ones

    // valid chunks with wrong contents
    const struct { const char* tag; size_t offset; uint32_t value; } lies[] = {
        {"TRNR", 0, 0x04030201}, {"TRNR", 4, 61},         {"TRNR", 8, 2},          {"TRNR", 16, 0},
        {"TRNR", 16, 5},         {"TRNR", 20, 0x7fc00000}, {"TRNR", 24, 3},        {"TRNR", 28, 1},
        {"TRNR", 12, 1},         {"TRNR", 60, 0x7ff00000}, {"TV0 ", 4, 0x7f800000}, {"TM4 ", 0, 0x7fc00000},
        {"TS2 ", 8, 0xbf800000}, {"TIDS", 4, 0xffffffff}, {"TGRD", 0, 0xff800000}, {"TRST", 0, 4}};
    const size_t lie_count = sizeof lies / sizeof *lies;
    for (size_t k = 0; k < lie_count + 3; k++) { // the last is true
        gsf_buffer lie;
        memset(&lie, 0, sizeof lie);
        for (int i = -2;; i++) {
            char tag[5] = "TRNR";
            if (i == -2) strcpy(tag, "TRST");
            else if (i >= GSF__SAVED_COLUMNS) break;
            else if (i >= 0) strcpy(tag, gsf__column_tags[i]);
            gsf_chunk chunk;
            CHECK(gsf_find_chunk(state.data, state.size, tag, &chunk));
            if (k == lie_count && strcmp(tag, "TVIS") == 0) continue; // left out
            if (k == lie_count + 1 && strcmp(tag, "TRST") == 0) continue;
            char* copy = (char*)malloc(chunk.size);
            memcpy(copy, chunk.data, chunk.size);
            if (k < lie_count && strcmp(tag, lies[k].tag) == 0)
                memcpy(copy + lies[k].offset, &lies[k].value, strcmp(tag, "TRST") ? 4 : 1); // (its low byte)
            gsf_append_chunk(ctx, &lie, tag, copy, chunk.size);
            free(copy);
        }
        gsf_append_last_chunk(ctx, &lie);
        if (!CHECK((gsf_splat_parse_trainer(ctx, trainer, "lie", lie.data, lie.size) != GSF_OK) == (k < lie_count + 2)))
            fprintf(stderr, "lie %zu\n", k);
        gsf_destroy_buffer(ctx, &lie);
    }
    gsf_destroy_buffer(ctx, &same);
    same = save_state(ctx, trainer);
    CHECK(same_text(&state, &same));
    gsf_destroy_buffer(ctx, &same);
    gsf_destroy_buffer(ctx, &state);
    gsf_splat_destroy_trainer(ctx, trainer);
}

// Views so narrow that each sees only part of the splats, which are in spatial order.
enum { LAZY_STEPS = 300, LAZY_SPLATS = 700 };
static gsf_trainer* make_narrow(gsf_context* ctx, const small_scene* s, int lazy) {
    gsf_train_view views[SCENE_VIEWS + 2];
    for (int v = 0; v < SCENE_VIEWS + 2; v++) {
        views[v] = s->views[v];
        views[v].camera.fx *= 6.0;
        views[v].camera.fy *= 6.0;
    }
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = LAZY_STEPS;
    desc.sh_interval = 100;
    desc.densify_from = 20;
    desc.densify_until = 120;
    desc.densify_interval = 50;
    desc.max_splats = LAZY_SPLATS + 100;
    desc.dropout = 0.1f;
    desc.lazy_adam = lazy;
    gsf_splats many;
    uint64_t state = 23;
    CHECK_OK(ctx, gsf_splat_make(ctx, LAZY_SPLATS, 1, &many));
    for (int i = 0; i < LAZY_SPLATS; i++) {
        for (int a = 0; a < 3; a++) {
            many.means[3 * i + a] = (float)test_random_in(&state, -1, 1);
            many.log_scales[3 * i + a] = (float)test_random_in(&state, -3.5, -2.5);
            many.sh[12 * i + a] = (float)test_random_in(&state, -0.5, 0.5);
        }
        many.means[3 * i + 1] = 2.0f * (float)i / LAZY_SPLATS - 1.0f;
        many.quats[4 * i] = 1.0f;
    }
    gsf_trainer* trainer = NULL;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, views, SCENE_VIEWS, &many, &trainer))) exit(2);
    gsf_splat_destroy(ctx, &many);
    CHECK_OK(ctx, gsf_splat_set_restored_views(ctx, trainer, views + SCENE_VIEWS, 1));
    return trainer;
}

static float* export_sh(gsf_context* ctx, const gsf_trainer* trainer, size_t* count) {
    gsf_splats splats;
    CHECK_OK(ctx, gsf_splat_copy_trained(ctx, trainer, &splats));
    const gsf_splats* same = gsf_splat_get_trained(trainer);
    *count = splats.count * 3 * (size_t)gsf_splat_count_sh(splats.sh_degree);
    CHECK(same->count == splats.count && memcmp(same->sh, splats.sh, *count * sizeof(float)) == 0);
    float* sh = (float*)malloc(*count * sizeof(float));
    memcpy(sh, splats.sh, *count * sizeof(float));
    gsf_splat_destroy(ctx, &splats);
    return sh;
}

// Lazy training gives the result of dense training. It is bit-identical for any workers, when its state is read in
// between, and when it resumes from a checkpoint.
static void test_lazy_training(const small_scene* s, gsf_cpu_level level) {
    int workers = 5;
    gsf_context ctx = open_context(level, NULL), other = open_context(level, &workers);
    gsf_trainer *dense = make_narrow(&ctx, s, 0), *lazy = make_narrow(&ctx, s, 1), *watched = make_narrow(&other, s, 1);
    size_t rests = 0, longest = 0, drawn = 0, n, dense_n;
    gsf_buffer middle;
    memset(&middle, 0, sizeof middle);
    for (int i = 0; i < LAZY_STEPS; i++) {
        gsf_train_stats a, b;
        CHECK_OK(&ctx, gsf_splat_step_trainer(&ctx, dense, &a));
        CHECK_OK(&ctx, gsf_splat_step_trainer(&ctx, lazy, &b));
        CHECK_OK(&other, gsf_splat_step_trainer(&other, watched, NULL));
        if (!CHECK(a.splats == b.splats)) break;
        CHECK_NEAR(b.loss, a.loss, 1e-3 * a.loss);
        for (size_t k = 0; k < gsf__model_blocks(lazy->model.count); k++) {
            rests += lazy->model.rest[k] > 0;
            drawn += lazy->model.rest[k] == 0;
            if (lazy->model.rest[k] > longest) longest = lazy->model.rest[k];
        }
        if (i % 37 == 5) free(export_sh(&other, watched, &n));
        if (i % 41 == 7) {
            float pixels[WIDTH * HEIGHT * 3], exported[WIDTH * HEIGHT * 3];
            gsf_render_output out;
            memset(&out, 0, sizeof out);
            out.color = gsf_wrap_image(pixels, GSF_F32, WIDTH, HEIGHT, 3);
            CHECK_OK(&other, gsf_splat_render_trainer(&other, watched, &s->views[1].camera, &out));
            gsf_splats splats;
            CHECK_OK(&other, gsf_splat_copy_trained(&other, watched, &splats));
            gsf_render_desc desc = watched->desc.render;
            desc.sh_bands = gsf__trainer_bands(watched, watched->iteration);
            out.color = gsf_wrap_image(exported, GSF_F32, WIDTH, HEIGHT, 3);
            CHECK_OK(&other, gsf_splat_render(&other, watched->rasterizer, &splats, &s->views[1].camera, &desc, &out));
            CHECK(memcmp(pixels, exported, sizeof pixels) == 0);
            gsf_splat_destroy(&other, &splats);
        }
        if (i == LAZY_STEPS / 2 + 3) middle = save_state(&other, watched);
    }
    float *a = export_sh(&ctx, dense, &dense_n), *b = export_sh(&ctx, lazy, &n);
    double sum = 0.0, total = 0.0;
    if (CHECK(n == dense_n))
        for (size_t i = 0; i < n; i++) {
            sum += ((double)b[i] - (double)a[i]) * ((double)b[i] - (double)a[i]);
            total += (double)a[i] * (double)a[i];
        }
    printf("lazy training (%s): %zu splats, %.0f %% of the blocks at rest in a step, for up to %zu steps; SH differ by %.2g\n",
           gsf_describe_cpu_level(level), lazy->model.count, 100.0 * (double)rests / (double)(rests + drawn), longest,
           sqrt(sum / total));
    CHECK(rests > drawn / 4 && longest > 100 && sqrt(sum / total) < 1e-3);

    gsf_buffer end = save_state(&ctx, lazy), seen = save_state(&other, watched), resumed, again;
    CHECK(same_text(&end, &seen));
    gsf_trainer* late = make_narrow(&ctx, s, 1);
    (void)gsf_splat_get_trained(late); // shown, then replaced
    CHECK_OK(&ctx, gsf_splat_parse_trainer(&ctx, late, "middle", middle.data, middle.size));
    again = save_state(&ctx, late);
    CHECK(same_text(&middle, &again));
    take_steps(&ctx, late, LAZY_STEPS / 2 - 4);
    resumed = save_state(&ctx, late);
    CHECK(same_text(&end, &resumed));
    gsf_splat_destroy_trainer(&ctx, late);

    late = make_narrow(&ctx, s, 0); // a dense run takes over
    CHECK_OK(&ctx, gsf_splat_parse_trainer(&ctx, late, "end", end.data, end.size));
    free(a);
    a = export_sh(&ctx, late, &dense_n);
    CHECK(dense_n == n && memcmp(a, b, n * sizeof(float)) == 0);
    size_t behind = 0;
    for (size_t k = 0; k < gsf__model_blocks(late->model.count); k++) behind += late->model.rest[k] != 0;
    CHECK(behind == 0);
    gsf_splat_destroy_trainer(&ctx, late);

    free(a);
    free(b);
    gsf_buffer* const texts[] = {&middle, &end, &seen, &resumed, &again};
    for (size_t i = 0; i < sizeof texts / sizeof *texts; i++) gsf_destroy_buffer(&ctx, texts[i]);
    gsf_splat_destroy_trainer(&ctx, dense);
    gsf_splat_destroy_trainer(&ctx, lazy);
    gsf_splat_destroy_trainer(&other, watched);
}

// ---- bad input ---------------------------------------------------------------------------

static void test_bad_input(gsf_context* ctx, const small_scene* s) {
    gsf_trainer* trainer;
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 5;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 0, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(trainer == NULL);
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, NULL, 2, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, NULL, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    gsf_splats splats = s->start;
    splats.count = 0;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, &splats, &trainer), GSF_ERROR_DEGENERATE);

    gsf_train_view bad = s->views[0];
    bad.camera.fx = NAN;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, &bad, 1, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    bad = s->views[0];
    bad.image.width = 3;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, &bad, 1, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    bad = s->views[0];
    bad.image.data = NULL;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, &bad, 1, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    bad = s->views[SCENE_VIEWS];
    bad.weight.dtype = GSF_U16;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, &bad, 1, &s->start, &trainer), GSF_ERROR_INVALID_ARGUMENT);
    s->weights[7] = -1.0f;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, &s->views[SCENE_VIEWS], 1, &s->start, &trainer), GSF_ERROR_NUMERIC);
    s->weights[7] = 0.7f;
    const float kept = s->pixels[1][5];
    s->pixels[1][5] = NAN;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 2, &s->start, &trainer), GSF_ERROR_NUMERIC);
    s->pixels[1][5] = kept;

    void* fields[] = {&desc.iterations, &desc.sh_degree, &desc.densify_interval, &desc.sh_interval, &desc.coarse_until,
                      &desc.densify_shared};
    for (size_t i = 0; i < sizeof fields / sizeof *fields; i++) {
        const int32_t wrong = -7;
        int32_t before;
        memcpy(&before, fields[i], 4);
        memcpy(fields[i], &wrong, 4);
        CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &trainer),
                     GSF_ERROR_INVALID_ARGUMENT);
        memcpy(fields[i], &before, 4);
    }
    float* floats[] = {&desc.lr_means, &desc.lr_opacity, &desc.extent, &desc.background[2], &desc.densify_grad,
                       &desc.prune_opacity, &desc.dropout, &desc.opacity_decay, &desc.scale_penalty,
                       &desc.depth_smoothness, &desc.render.near_plane, &desc.lambda_ssim, &desc.opacity_penalty,
                       &desc.mcmc_noise, &desc.sharpness};
    for (size_t i = 0; i < sizeof floats / sizeof *floats; i++) {
        *floats[i] = NAN;
        CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &trainer),
                     GSF_ERROR_INVALID_ARGUMENT);
        *floats[i] = 0.0f;
    }
    const uint8_t hidden[SPLATS] = {0};
    desc.render.hidden = hidden;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, 1, &s->start, &trainer),
                     GSF_ERROR_INVALID_ARGUMENT);
    desc.render.hidden = NULL;

    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer));
    gsf_buffer before = save_state(ctx, trainer);
    bad = s->views[0];
    bad.image.channels = 4;
    CHECK_RESULT(ctx, gsf_splat_set_restored_views(ctx, trainer, &bad, 1), GSF_ERROR_INVALID_ARGUMENT);
    gsf_request_cancel(ctx);
    CHECK_RESULT(ctx, gsf_splat_step_trainer(ctx, trainer, NULL), GSF_ERROR_CANCELLED);
    gsf_clear_cancel(ctx);
    gsf_buffer after = save_state(ctx, trainer);
    CHECK(same_text(&before, &after));
    take_steps(ctx, trainer, 5);
    gsf_destroy_buffer(ctx, &before);
    gsf_destroy_buffer(ctx, &after);
    gsf_splat_destroy_trainer(ctx, trainer);
}

static void test_degenerate(gsf_context* ctx, const small_scene* s) {
    gsf_train_desc desc = make_busy_desc();
    gsf_train_stats stats;
    gsf_trainer* trainer;
    // NaN in splats: left out and counted
    gsf_splats splats;
    CHECK_OK(ctx, gsf_splat_make(ctx, SPLATS, 1, &splats));
    memcpy(splats.means, s->start.means, SPLATS * 23 * sizeof(float)); // one block
    splats.means[3] = NAN;
    splats.sh[5 * 12 + 7] = INFINITY;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &splats, &trainer));
    CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, &stats));
    CHECK(stats.rejected == 2 && stats.splats == SPLATS - 2 && trainer->view.ids[1] == 2);
    gsf_splat_destroy_trainer(ctx, trainer);
    for (int i = 0; i < SPLATS; i++) splats.quats[4 * i] = NAN;
    CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &splats, &trainer), GSF_ERROR_DEGENERATE);
    gsf_splat_destroy(ctx, &splats);

    // huge values stay finite
    gsf_splats wild = s->start;
    float scales[SPLATS * 3];
    for (int i = 0; i < SPLATS * 3; i++) scales[i] = i % 2 ? 85.0f : -85.0f;
    wild.log_scales = scales;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, SCENE_VIEWS, &wild, &trainer));
    take_steps(ctx, trainer, 60);
    int finite = 1;
    for (int g = 0; g < GSF__GROUPS; g++)
        finite = finite &&
                 gsf__all_finite(trainer->model.groups[g].value, trainer->model.count * trainer->model.groups[g].width);
    CHECK(finite);
    gsf_splat_destroy_trainer(ctx, trainer);

    // one pixel; nothing in sight; everything pruned
    float pixel[3] = {0.3f, 0.4f, 0.5f};
    gsf_train_view view;
    memset(&view, 0, sizeof view);
    view.camera = make_camera(0.0, 0.0, 1, 1);
    view.image = gsf_wrap_image(pixel, GSF_F32, 1, 1, 3);
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, &view, 1, &s->start, &trainer));
    take_steps(ctx, trainer, 60);
    gsf_splat_destroy_trainer(ctx, trainer);
    view.camera.w2c[14] = -50.0; // all behind the camera
    desc.opacity_decay = 0.05f;
    CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, &view, 1, &s->start, &trainer));
    CHECK(trainer->desc.extent == 1.0f);
    take_steps(ctx, trainer, 60);
    CHECK(trainer->model.count == 0); // faded and pruned; training continues without splats
    gsf_buffer state = save_state(ctx, trainer);
    CHECK_OK(ctx, gsf_splat_parse_trainer(ctx, trainer, "empty", state.data, state.size));
    gsf_destroy_buffer(ctx, &state);
    gsf_splats none;
    CHECK_OK(ctx, gsf_splat_copy_trained(ctx, trainer, &none));
    gsf_splat_destroy(ctx, &none);
    gsf_splat_destroy_trainer(ctx, trainer);
}

// ---- memory --------------------------------------------------------------------------------

typedef struct failing { size_t live, calls, fail_at; } failing; // fail_at: this allocation fails, once (0 = none)

static void* failing_alloc(void* user, size_t size) {
    failing* f = (failing*)user;
    if (++f->calls == f->fail_at) return NULL;
    f->live++;
    return malloc(size);
}

static void failing_free(void* user, void* memory) {
    ((failing*)user)->live--;
    free(memory);
}

// A short run in which allocation `fail_at` fails. The failed step is repeated: the failure must not have changed any
// state.
static gsf_result run_failing(const small_scene* s, failing* f, int mcmc, gsf_buffer* end) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.allocator.alloc_fn = failing_alloc;
    ctx.allocator.free_fn = failing_free;
    ctx.allocator.user = f;
    ctx.threads = 1;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    gsf_train_desc desc = mcmc ? busy_mcmc_desc() : make_busy_desc();
    gsf_trainer* trainer;
    gsf_buffer chunks;
    memset(&chunks, 0, sizeof chunks);
    gsf_result result = gsf_splat_make_trainer(&ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer), worst = result;
    if (result == GSF_OK) {
        result = gsf_splat_set_restored_views(&ctx, trainer, s->views + SCENE_VIEWS, 2);
        if (result != GSF_OK) {
            worst = result;
            CHECK_OK(&ctx, gsf_splat_set_restored_views(&ctx, trainer, s->views + SCENE_VIEWS, 2));
        }
        for (int i = 0; i < 24; i++) {
            result = gsf_splat_step_trainer(&ctx, trainer, NULL);
            if (result == GSF_OK) continue;
            worst = result;
            CHECK_OK(&ctx, gsf_splat_step_trainer(&ctx, trainer, NULL));
        }
        gsf_splat_format_trainer(&ctx, trainer, &chunks);
        gsf_append_last_chunk(&ctx, &chunks);
        if (chunks.failed) worst = GSF_ERROR_OUT_OF_MEMORY;
        else if (end->size == 0) {
            end->data = (char*)malloc(chunks.size);
            memcpy(end->data, chunks.data, end->size = chunks.size);
        } else {
            CHECK(same_text(end, &chunks));
        }
        gsf_destroy_buffer(&ctx, &chunks);
        gsf_splat_destroy_trainer(&ctx, trainer);
    }
    CHECK(f->live == 0);
    return worst;
}

static void test_trainer_out_of_memory(const small_scene* s, int mcmc) {
    gsf_buffer end;
    memset(&end, 0, sizeof end);
    failing f = {0, 0, 0};
    CHECK(run_failing(s, &f, mcmc, &end) == GSF_OK);
    const size_t calls = f.calls;
    size_t noticed = 0;
    for (size_t k = 1; k <= calls; k++) {
        failing g = {0, 0, k};
        const gsf_result result = run_failing(s, &g, mcmc, &end);
        noticed += result == GSF_ERROR_OUT_OF_MEMORY;
        CHECK(result == GSF_ERROR_OUT_OF_MEMORY || result == GSF_OK);
    }
    CHECK(noticed == calls);
    printf("%zu allocations failed one by one\n", calls);
    free(end.data);
}

// Once all photos have been used, steps between densifications do not allocate.
static void test_steady(const small_scene* s) {
    failing f = {0, 0, 0};
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.allocator.alloc_fn = failing_alloc;
    ctx.allocator.free_fn = failing_free;
    ctx.allocator.user = &f;
    ctx.threads = 1;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 100;
    desc.densify_until = -1;
    gsf_trainer* trainer;
    if (!CHECK_OK(&ctx, gsf_splat_make_trainer(&ctx, &desc, s->views, SCENE_VIEWS, &s->start, &trainer))) return;
    take_steps(&ctx, trainer, 2 * SCENE_VIEWS);
    const size_t before = f.calls;
    take_steps(&ctx, trainer, 20);
    CHECK(f.calls - before <= 2); // the rasterizer's lists may still grow a little
    gsf_splat_destroy_trainer(&ctx, trainer);
    CHECK(f.live == 0);
}

// ---- order ---------------------------------------------------------------------

// Every row is moved as a whole (its id tells its old index), neighbours in memory become closer in space, special
// values are kept, and a second sort changes nothing.
static void test_sort(gsf_context* ctx) {
    enum { COUNT = 3000 };
    gsf_splats s, was;
    CHECK_OK(ctx, gsf_splat_make(ctx, COUNT, 1, &s));
    CHECK_OK(ctx, gsf_splat_make(ctx, COUNT, 1, &was));
    uint64_t state = 11;
    const size_t floats = COUNT * (size_t)(3 + 3 + 4 + 1 + 12); // one block, see gsf_splat_make
    for (size_t i = 0; i < floats; i++) s.means[i] = (float)test_random_in(&state, -2, 2);
    s.means[3 * 7] = NAN;
    s.means[3 * 8 + 1] = INFINITY;
    s.means[3 * 9 + 2] = -3e38f;
    memcpy(was.means, s.means, floats * sizeof(float));
    double before = 0.0, after = 0.0;
    CHECK_OK(ctx, gsf_splat_sort(ctx, &s));
    uint8_t met[COUNT];
    memset(met, 0, sizeof met);
    for (size_t i = 0; i < COUNT; i++) {
        const size_t from = s.ids[i];
        if (!CHECK(from < COUNT && !met[from])) break;
        met[from] = 1;
        CHECK(memcmp(s.means + 3 * i, was.means + 3 * from, 3 * sizeof(float)) == 0);
        CHECK(memcmp(s.log_scales + 3 * i, was.log_scales + 3 * from, 3 * sizeof(float)) == 0);
        CHECK(memcmp(s.quats + 4 * i, was.quats + 4 * from, 4 * sizeof(float)) == 0);
        CHECK(s.opacity_logits[i] == was.opacity_logits[from]);
        CHECK(memcmp(s.sh + 12 * i, was.sh + 12 * from, 12 * sizeof(float)) == 0);
        for (size_t c = 0; c < 3 && i > 0; c++) {
            const double a = fabs((double)s.means[3 * i + c] - (double)s.means[3 * i - 3 + c]);
            const double b = fabs((double)was.means[3 * i + c] - (double)was.means[3 * i - 3 + c]);
            if (a < 10.0) after += a;
            if (b < 10.0) before += b;
        }
    }
    CHECK(after < 0.2 * before);
    gsf_splat_destroy(ctx, &was);
    CHECK_OK(ctx, gsf_splat_make(ctx, COUNT, 1, &was));
    memcpy(was.means, s.means, floats * sizeof(float));
    memcpy(was.ids, s.ids, COUNT * sizeof(uint32_t));
    CHECK_OK(ctx, gsf_splat_sort(ctx, &s));
    CHECK(memcmp(was.means, s.means, floats * sizeof(float)) == 0);
    CHECK(memcmp(was.ids, s.ids, COUNT * sizeof(uint32_t)) == 0);
    gsf_splat_destroy(ctx, &was);
    gsf_splat_destroy(ctx, &s);
    CHECK_OK(ctx, gsf_splat_make(ctx, 0, 0, &s));
    CHECK_OK(ctx, gsf_splat_sort(ctx, &s));
    gsf_splat_destroy(ctx, &s);
}

// The drawn splats in order of depth, those of the same depth in order of their index; one and several chunks.
static void test_depth_order(gsf_context* ctx) {
    static const size_t counts[] = {0, 1, 8192, 8193, 60000};
    gsf_rasterizer* r;
    CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &r));
    r->width = r->height = 1;
    uint64_t state = 12;
    for (size_t c = 0; c < GSF__COUNT(counts); c++) {
        size_t drawn = 0, wrong = 0;
        r->splat_count = counts[c];
        CHECK_OK(ctx, gsf__reserve_frame(ctx, r));
        for (size_t i = 0; i < counts[c]; i++) {
            const double x = test_random_in(&state, -60, 60);
            r->records[i].depth = (float)exp2(i % 2 ? x : floor(x / 30)); // half of them are of four depths
            r->records[i].radius = test_random_in(&state, 0, 1) < 0.7;
            drawn += (size_t)r->records[i].radius;
        }
        CHECK_OK(ctx, gsf__order(ctx, r));
        CHECK(r->drawn_count == drawn);
        for (size_t k = 0; k < drawn; k++) {
            const gsf__record* rec = r->records + (uint32_t)r->order[k];
            wrong += rec->radius == 0 || (k > 0 && r->order[k] <= r->order[k - 1]);
            wrong += k > 0 && rec->depth < r->records[(uint32_t)r->order[k - 1]].depth;
        }
        CHECK(wrong == 0);
    }
    gsf_splat_destroy_rasterizer(ctx, r);
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    test_sort(&ctx);
    test_depth_order(&ctx);
    small_scene s = make_small_scene(&ctx);
    test_loss_derivative(&ctx);
    for (int level = GSF_CPU_SCALAR; level <= GSF_CPU_SIMD128; level++) test_loss_accuracy((gsf_cpu_level)level);
    for (int level = GSF_CPU_SCALAR; level <= (int)ctx.cpu_level; level++) test_loss_weights((gsf_cpu_level)level);
    test_smoothness_derivative(&ctx);
    test_smoothness_levels(ctx.cpu_level);
    test_adam_rejects(&ctx);
    test_adam_bands(&ctx);
    for (int level = GSF_CPU_SCALAR; level <= (int)ctx.cpu_level; level++) {
        gsf_context one;
        test_context_zero(&one);
        one.cpu_level = (gsf_cpu_level)level;
        CHECK_OK(&one, gsf_init_context(&one));
        test_lazy_adam(&one);
    }
    test_regularisers(&ctx);
    test_cap(&ctx);
    test_shared(&ctx);
    test_mcmc_share();
    test_mcmc_densify(&ctx);
    test_mcmc_clamped(&ctx);
    test_mcmc_noise(&ctx);
    test_mcmc_render(&ctx);
    test_learns(&ctx, &s);
    test_mcmc_learns(&ctx, &s);
    test_masked_training(&ctx, &s);
    test_trainer_background(&ctx, &s);
    test_candidates(&ctx, &s);
    test_order_and_visits(&ctx, &s);
    test_absolute_statistic(&ctx, &s);
    test_restored_gradient(&ctx, &s);
    test_coarse(&ctx, &s);
    test_sharpness(&ctx, &s);
    test_settings(&ctx, &s);
    test_linear_photos(&ctx, &s);
    for (int lazy = 0; lazy < 2; lazy++) test_zero_rates(&ctx, &s, lazy);
    for (int mcmc = 0; mcmc < 2; mcmc++) test_trainer_workers(&s, ctx.cpu_level, mcmc);
    for (int level = GSF_CPU_SCALAR; level <= (int)ctx.cpu_level; level++) test_lazy_training(&s, (gsf_cpu_level)level);
    for (int mcmc = 0; mcmc < 2; mcmc++) test_resume(&ctx, &s, mcmc);
    test_damaged_checkpoints(&ctx, &s);
    test_bad_input(&ctx, &s);
    test_degenerate(&ctx, &s);
    for (int mcmc = 0; mcmc < 2; mcmc++) test_trainer_out_of_memory(&s, mcmc);
    test_steady(&s);
    destroy_scene(&ctx, &s);
    return test_report();
}
