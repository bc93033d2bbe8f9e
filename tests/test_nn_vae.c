// test_nn_vae.c - convolutions, those of the metrics, too, against a double-precision reference; a small random autoencoder:
// CPU levels, workers, tiles, chunks, damaged files, NaN, cancellation, out of memory. golden_restorer compares with diffusers.
// gcc -O2 -std=c11 -fopenmp -I. -Itests tests/test_nn_vae.c -lm
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

static float* random_floats(uint64_t* seed, size_t count, double scale) {
    float* x = (float*)malloc(count * sizeof(float));
    for (size_t i = 0; i < count; i++) x[i] = (float)test_random_in(seed, -scale, scale);
    return x;
}

// ---- convolution

typedef struct conv_case {
    int64_t frames, height, width, in, out, kt, kernel;
    int halve, accumulate, before, bias;
} conv_case;

static int64_t case_index(const conv_case* c, int64_t n, int64_t i, int64_t t, int64_t y, int64_t x) { // of a weight
    return (((n * c->in + i) * c->kt + t) * c->kernel + y) * c->kernel + x;
}

// Value (t, y, x, c) of the input: zero outside the frame; before the first frame, `before` or the first frame.
static double case_input(const conv_case* c, const float* x, const float* before, int64_t t, int64_t row, int64_t column,
                         int64_t i) {
    if (row < 0 || column < 0 || row >= c->height || column >= c->width) return 0.0;
    const float* frames = t < 0 && before ? before : x;
    const int64_t at = t >= 0 ? t : before ? t + 2 : 0;
    return (double)frames[((at * c->height + row) * c->width + column) * c->in + i];
}

// The plain formula in double, and the sum of its absolute terms.
static double case_output(const conv_case* c, const float* x, const float* before, const float* w, int64_t t, int64_t y,
                          int64_t column, int64_t n, double* terms) {
    const int64_t stride = c->halve ? 2 : 1, pad = c->halve ? 0 : c->kernel / 2;
    double sum = 0.0;
    for (int64_t i = 0; i < c->in; i++)
        for (int64_t kt = 0; kt < c->kt; kt++)
            for (int64_t ky = 0; ky < c->kernel; ky++)
                for (int64_t kx = 0; kx < c->kernel; kx++) {
                    const double v = case_input(c, x, before, t - c->kt + 1 + kt, y * stride + ky - pad,
                                                column * stride + kx - pad, i) * (double)w[case_index(c, n, i, kt, ky, kx)];
                    sum += v;
                    *terms += fabs(v);
                }
    return sum;
}

// Weights as bf16 or f16 at an odd address; `w` is rounded to the values that they represent.
static void* narrow_weights(float* w, size_t count, gsf_nn_dtype dtype, char** base) {
    *base = (char*)malloc(count * 2 + 1);
    for (size_t i = 0; i < count; i++) {
        const uint16_t bits = dtype == GSF_NN_BF16 ? gsf__float_to_bf16(w[i]) : gsf__float_to_half(w[i]);
        memcpy(*base + 1 + 2 * i, &bits, 2);
        w[i] = dtype == GSF_NN_BF16 ? gsf__bf16_to_float(bits) : gsf__half_to_float(bits);
    }
    return *base + 1;
}

static void check_conv_values(const conv_case* c, const float* x, const float* before, const float* w, const float* bias,
                              const float* start, const float* y) {
    const int64_t height = c->halve ? c->height / 2 : c->height, width = c->halve ? c->width / 2 : c->width;
    double worst = 0.0;
    for (int64_t at = 0; at < c->frames * height * width * c->out; at++) {
        const int64_t n = at % c->out, column = at / c->out % width, row = at / c->out / width % height;
        const int64_t t = at / c->out / width / height;
        double terms = 1e-30;
        double value = case_output(c, x, before, w, t, row, column, n, &terms);
        if (bias) value += (double)bias[n], terms += fabs((double)bias[n]);
        if (c->accumulate) value += (double)start[at], terms += fabs((double)start[at]);
        const double error = fabs((double)y[at] - value) / terms;
        if (!(error <= worst)) worst = error;
    }
    CHECK(worst < 1e-6);
}

static void check_conv(gsf_context* ctx, const conv_case* c, gsf_nn_dtype dtype, uint64_t* seed) {
    const size_t plane = (size_t)(c->height * c->width), count = (size_t)(c->out * c->in * c->kt * c->kernel * c->kernel);
    const size_t out = (size_t)(c->frames * (c->halve ? (c->height / 2) * (c->width / 2) : c->height * c->width) * c->out);
    float *x = random_floats(seed, (size_t)(c->frames * c->in) * plane, 2.0), *w = random_floats(seed, count, 1.0);
    float *before = random_floats(seed, (size_t)(2 * c->in) * plane, 2.0), *bias = random_floats(seed, (size_t)c->out, 1.0);
    float *start = random_floats(seed, out, 3.0), *y = (float*)malloc(out * sizeof(float));
    const int64_t shape[5] = {c->out, c->in, c->kt, c->kernel, c->kernel};
    const int64_t flat[4] = {c->out, c->in, c->kernel, c->kernel};
    gsf_nn_tensor weight = gsf_nn_wrap_tensor("w", w, c->kt == 1 ? 4 : 5, c->kt == 1 ? flat : shape);
    const gsf_nn_tensor b = gsf_nn_wrap_tensor("b", bias, 1, shape);
    char* narrow = NULL;
    gsf__nn_conv_desc desc;
    memset(&desc, 0, sizeof desc);
    if (dtype != GSF_NN_F32) weight.data = narrow_weights(w, count, dtype, &narrow);
    weight.dtype = dtype;
    memcpy(y, start, out * sizeof(float));
    desc.x = x;
    desc.frames = c->frames;
    desc.height = c->height;
    desc.width = c->width;
    desc.weight = &weight;
    desc.bias = c->bias ? &b : NULL;
    desc.before = c->before ? before : NULL;
    desc.halve = c->halve;
    desc.accumulate = c->accumulate;
    desc.y = y;
    if (CHECK_OK(ctx, gsf__nn_convolve(ctx, NULL, &desc)))
        check_conv_values(c, x, desc.before, w, c->bias ? bias : NULL, start, y);
    free(x), free(w), free(before), free(bias), free(start), free(y), free(narrow);
}

static void test_convolve(void) {
    static const conv_case cases[] = {
        {1, 1, 1, 1, 1, 3, 3, 0, 0, 0, 1},   {1, 5, 7, 3, 5, 3, 3, 0, 0, 0, 1},  {4, 6, 31, 16, 16, 3, 3, 0, 1, 1, 1},
        {3, 9, 13, 17, 33, 3, 3, 0, 0, 1, 0}, {2, 4, 61, 8, 24, 1, 3, 0, 0, 0, 1}, {3, 7, 9, 5, 20, 1, 3, 1, 0, 0, 1},
        {1, 8, 64, 6, 8, 1, 3, 1, 1, 0, 1},  {2, 3, 5, 40, 7, 1, 1, 0, 1, 0, 1}, {1, 2, 6, 100, 16, 3, 3, 0, 0, 0, 1},
        {5, 3, 3, 2, 3, 3, 1, 0, 0, 1, 1},   {1, 2, 2, 9, 18, 1, 3, 1, 0, 0, 0},
        {1, 17, 59, 4, 40, 3, 3, 0, 0, 0, 1}, {2, 9, 28, 3, 32, 1, 3, 0, 0, 1, 1},
        // by Winograd's
        {1, 1, 1, 16, 16, 1, 3, 0, 0, 0, 1}, {5, 3, 2, 16, 17, 1, 3, 0, 0, 0, 1}, {3, 7, 9, 24, 48, 1, 3, 0, 0, 1, 1},
        {9, 19, 34, 20, 24, 1, 3, 0, 0, 0, 0}, {2, 1, 6, 300, 33, 1, 3, 0, 0, 0, 1}, {2, 21, 25, 37, 80, 3, 3, 0, 1, 0, 1},
    };
    gsf_context ctx;
    uint64_t seed = 1;
    for (int level = GSF_CPU_SCALAR; level <= GSF_CPU_AMX; level++) {
        test_context_zero(&ctx);
        ctx.cpu_level = (gsf_cpu_level)level;
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        for (size_t i = 0; i < GSF__COUNT(cases); i++)
            check_conv(&ctx, &cases[i], (gsf_nn_dtype)(GSF_NN_F32 + i % 3), &seed);
    }
    gsf__nn_conv_desc desc;
    float value = 0.0f;
    const int64_t shape[5] = {1, 1, 2, 3, 3};
    gsf_nn_tensor weight = gsf_nn_wrap_tensor("odd.weight", &value, 5, shape);
    memset(&desc, 0, sizeof desc);
    CHECK_RESULT(&ctx, gsf__nn_convolve(&ctx, NULL, &desc), GSF_ERROR_INVALID_ARGUMENT);
    desc.x = &value, desc.y = &value, desc.weight = &weight, desc.frames = desc.height = desc.width = 1;
    CHECK_RESULT(&ctx, gsf__nn_convolve(&ctx, NULL, &desc), GSF_ERROR_UNSUPPORTED);
    CHECK(strstr(ctx.error, "odd.weight") != NULL);
}

// ---- convolutions of feature maps (metrics), among them Winograd's

// The convolution of `pad` zeros around `map` at `stride`, with ReLU of the input, in double.
static void check_map_values(const gsf__map* map, const float* w, const float* bias, int64_t kernel, int64_t stride,
                             int64_t pad, int rectify, const gsf__map* y) {
    double worst = 0.0;
    for (int64_t at = 0; at < y->images * y->height * y->width * y->channels; at++) {
        const int64_t n = at % y->channels, pixel = at / y->channels, column = pixel % y->width * stride - pad;
        const int64_t image = pixel / y->width / y->height, row = pixel / y->width % y->height * stride - pad;
        double value = (double)bias[n], terms = fabs(value);
        for (int64_t i = 0; i < map->channels; i++)
            for (int64_t k = 0; k < kernel * kernel; k++) {
                const int64_t v = row + k / kernel, u = column + k % kernel;
                if (v < 0 || u < 0 || v >= map->height || u >= map->width) continue;
                const float of = map->data[((image * map->height + v) * map->width + u) * map->pitch + i];
                const double by = (double)w[(n * map->channels + i) * kernel * kernel + k];
                const double term = (rectify && of < 0.0f ? 0.0 : (double)of) * by;
                value += term;
                terms += fabs(term);
            }
        const double error = fabs((double)y->data[pixel * y->pitch + n] - value) / terms;
        if (!(error <= worst)) worst = error;
    }
    CHECK(worst < 1e-6);
}

static void check_map(gsf_context* ctx, gsf_context* other, const int64_t sizes[9], int rectify, uint64_t* seed) {
    const int64_t kernel = sizes[5], stride = sizes[6], pad = sizes[7], spare = sizes[8]; // spare: channels of a wider map
    gsf__map x = {NULL, sizes[0], sizes[1], sizes[2], sizes[3], sizes[3] + spare};
    gsf__map y = {NULL, x.images, (x.height + 2 * pad - kernel) / stride + 1, (x.width + 2 * pad - kernel) / stride + 1,
                  sizes[4], sizes[4] + spare};
    const int64_t shape[4] = {y.channels, x.channels, kernel, kernel};
    const size_t in = (size_t)(x.images * x.height * x.width * x.pitch);
    const size_t out = (size_t)(y.images * y.height * y.width * y.pitch);
    float *w = random_floats(seed, (size_t)(y.channels * x.channels * kernel * kernel), 1.0);
    float *bias = random_floats(seed, (size_t)y.channels, 1.0), *again = (float*)calloc(out, sizeof(float));
    const gsf_nn_tensor weight = gsf_nn_wrap_tensor("w", w, 4, shape), biases = gsf_nn_wrap_tensor("b", bias, 1, shape);
    const gsf__nn_layer layer = {&weight, &biases};
    gsf__map_layers layers;
    memset(&layers, 0, sizeof layers);
    x.data = random_floats(seed, in, 2.0);
    y.data = (float*)calloc(out, sizeof(float));
    for (int run = 0; run < 2; run++) // the second with the packed weights of the first
        CHECK_OK(ctx, gsf__map_convolve(ctx, &layers, &layer, stride, pad, rectify, &x, &y));
    CHECK(layers.count == 1);
    check_map_values(&x, w, bias, kernel, stride, pad, rectify, &y);
    for (size_t i = 0; i < out; i++) CHECK(i % (size_t)y.pitch < (size_t)y.channels || y.data[i] == 0.0f); // of the wider map
    gsf__destroy_map_layers(ctx, &layers);
    gsf__map same = y;
    same.data = again;
    CHECK_OK(other, gsf__map_convolve(other, &layers, &layer, stride, pad, rectify, &x, &same));
    CHECK(memcmp(y.data, again, out * sizeof(float)) == 0);
    gsf__destroy_map_layers(other, &layers);
    free(w), free(bias), free(again), free(x.data), free(y.data);
}

static void test_maps(void) {
    static const int64_t sizes[][9] = { // images, height, width, in, out, kernel, stride, pad, spare
        {1, 1, 1, 16, 16, 3, 1, 1, 0},   {2, 7, 9, 16, 24, 3, 1, 1, 0},  {1, 24, 31, 40, 33, 3, 1, 1, 3},
        {1, 2, 2, 300, 17, 3, 1, 1, 0},  {1, 33, 46, 17, 64, 3, 1, 1, 0}, {1, 9, 8, 3, 20, 3, 2, 0, 0},
        {1, 19, 23, 3, 16, 11, 4, 2, 0}, {2, 6, 5, 20, 18, 5, 1, 2, 1},  {1, 5, 6, 24, 40, 1, 1, 0, 2},
    };
    gsf_context ctx, other;
    uint64_t seed = 3;
    for (int level = GSF_CPU_SCALAR; level <= GSF_CPU_AMX; level++) {
        test_context_zero(&ctx);
        ctx.cpu_level = (gsf_cpu_level)level;
        other = ctx;
        other.parallel.for_fn = backwards;
        other.parallel.worker_count = 3;
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        CHECK_OK(&other, gsf_init_context(&other));
        for (size_t i = 0; i < GSF__COUNT(sizes); i++) check_map(&ctx, &other, sizes[i], (int)(i % 2), &seed);
    }
}

// ---- a random autoencoder

typedef struct vae_shape { int32_t channels[4], levels, groups, layers, latents, ratio; } vae_shape;

typedef struct vae_file { // tensors under construction
    gsf_nn_tensor tensors[600];
    char names[600][96];
    size_t count;
    uint64_t seed;
} vae_file;

static void add_tensor(vae_file* f, int32_t rank, const int64_t* shape, double centre, double spread, const char* format,
                       ...) {
    va_list args;
    va_start(args, format);
    vsnprintf(f->names[f->count], sizeof f->names[0], format, args);
    va_end(args);
    gsf_nn_tensor t = gsf_nn_wrap_tensor(f->names[f->count], NULL, rank, shape);
    float* data = random_floats(&f->seed, (size_t)t.count, spread);
    for (int64_t i = 0; i < t.count; i++) data[i] += (float)centre;
    t.data = data;
    f->tensors[f->count++] = t;
}

static void add_conv(vae_file* f, int64_t in, int64_t out, int64_t kt, int64_t kernel, const char* name) {
    int64_t shape[5] = {out, in, kt, kernel, kernel};
    const double spread = 1.7 / sqrt((double)(in * (kt ? kt : 1) * kernel * kernel));
    if (!kt) shape[2] = kernel;
    add_tensor(f, kt ? 5 : 4, shape, 0.0, spread, "%s.weight", name);
    add_tensor(f, 1, shape, 0.0, 0.2, "%s.bias", name);
}

// latents 0: a plain group norm
static void add_norm(vae_file* f, int64_t channels, int64_t latents, const char* name) {
    char full[96];
    add_tensor(f, 1, &channels, 1.0, 0.5, "%s%s.weight", name, latents ? ".norm_layer" : "");
    add_tensor(f, 1, &channels, 0.0, 0.5, "%s%s.bias", name, latents ? ".norm_layer" : "");
    if (!latents) return;
    snprintf(full, sizeof full, "%s.conv_y.conv", name);
    add_conv(f, latents, channels, 1, 1, full);
    snprintf(full, sizeof full, "%s.conv_b.conv", name);
    add_conv(f, latents, channels, 1, 1, full);
}

static void add_resnets(vae_file* f, int64_t in, int64_t out, int64_t latents, int count, const char* block) {
    char name[96];
    for (int i = 0; i < count; i++, in = out) {
        snprintf(name, sizeof name, "%s.resnets.%d.norm1", block, i);
        add_norm(f, in, latents, name);
        snprintf(name, sizeof name, "%s.resnets.%d.conv1.conv", block, i);
        add_conv(f, in, out, 3, 3, name);
        snprintf(name, sizeof name, "%s.resnets.%d.norm2", block, i);
        add_norm(f, out, latents, name);
        snprintf(name, sizeof name, "%s.resnets.%d.conv2.conv", block, i);
        add_conv(f, out, out, 3, 3, name);
        snprintf(name, sizeof name, "%s.resnets.%d.conv_shortcut", block, i);
        if (in != out) add_conv(f, in, out, 1, 1, name);
    }
}

static void add_nets(vae_file* f, const vae_shape* s) {
    const int last = s->levels - 1;
    char name[96];
    add_conv(f, 3, s->channels[0], 3, 3, "encoder.conv_in.conv");
    for (int i = 0; i <= last; i++) {
        snprintf(name, sizeof name, "encoder.down_blocks.%d", i);
        add_resnets(f, s->channels[i ? i - 1 : 0], s->channels[i], 0, s->layers, name);
        snprintf(name, sizeof name, "encoder.down_blocks.%d.downsamplers.0.conv", i);
        if (i < last) add_conv(f, s->channels[i], s->channels[i], 0, 3, name);
        snprintf(name, sizeof name, "decoder.up_blocks.%d", i);
        add_resnets(f, s->channels[last - (i ? i - 1 : 0)], s->channels[last - i], s->latents, s->layers + 1, name);
        snprintf(name, sizeof name, "decoder.up_blocks.%d.upsamplers.0.conv", i);
        if (i < last) add_conv(f, s->channels[last - i], s->channels[last - i], 0, 3, name);
    }
    add_resnets(f, s->channels[last], s->channels[last], 0, 2, "encoder.mid_block");
    add_resnets(f, s->channels[last], s->channels[last], s->latents, 2, "decoder.mid_block");
    add_norm(f, s->channels[last], 0, "encoder.norm_out");
    add_norm(f, s->channels[0], s->latents, "decoder.norm_out");
    add_conv(f, s->channels[last], 2 * s->latents, 3, 3, "encoder.conv_out.conv");
    add_conv(f, s->latents, s->channels[last], 3, 3, "decoder.conv_in.conv");
    add_conv(f, s->channels[0], 3, 3, 3, "decoder.conv_out.conv");
}

static vae_file* make_vae_file(const vae_shape* s) {
    vae_file* f = (vae_file*)calloc(1, sizeof *f);
    f->seed = 7;
    add_nets(f, s);
    return f;
}

static void free_file(vae_file* f) {
    for (size_t i = 0; i < f->count; i++) free((void*)(uintptr_t)f->tensors[i].data);
    free(f);
}

static gsf_nn_tensor* file_tensor(vae_file* f, const char* name) {
    for (size_t i = 0; i < f->count; i++)
        if (strcmp(f->tensors[i].name, name) == 0) return &f->tensors[i];
    fprintf(stderr, "no tensor %s\n", name);
    exit(2);
}

static void save_config(gsf_context* ctx, const vae_shape* s, const char* more) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_append_text(ctx, &text, "{\"block_out_channels\": [");
    for (int i = 0; i < s->levels; i++) gsf_append_text(ctx, &text, "%s%d", i ? ", " : "", (int)s->channels[i]);
    gsf_append_text(ctx, &text, "], \"norm_num_groups\": %d, \"layers_per_block\": %d, \"latent_channels\": %d, "
                    "\"temporal_compression_ratio\": %d, \"sample_height\": 40, \"sample_width\": 32%s}", (int)s->groups,
                    (int)s->layers, (int)s->latents, (int)s->ratio, more);
    CHECK_OK(ctx, gsf_write_file(ctx, test_scratch("config.json"), text.data, text.size));
    gsf_destroy_buffer(ctx, &text);
}

static void save_model(gsf_context* ctx, const vae_shape* s, const vae_file* f) {
    save_config(ctx, s, "");
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("diffusion_pytorch_model.safetensors"), f->tensors, f->count));
}

static const char* model_folder(void) {
    static char folder[1024];
    snprintf(folder, sizeof folder, "%s", test_scratch(""));
    folder[strlen(folder) - 1] = 0; // the separator
    return folder;
}

static const vae_shape tiny_vae = {{6, 12, 20, 0}, 3, 2, 1, 4, 4}; // 4 pixels and 4 frames per latent

typedef struct vae_result {
    float *mean, *logvar, *video;
    size_t latents, pixels;
    gsf_nn_vae_info encoded, decoded;
} vae_result;

static void free_result(vae_result* r) { free(r->mean), free(r->logvar), free(r->video); }

// Encodes random frames and decodes the mean.
static vae_result both_ways(gsf_context* ctx, const gsf_nn_vae_desc* desc, int64_t frames, int64_t height, int64_t width) {
    gsf_nn_vae vae;
    vae_result r;
    uint64_t seed = 3;
    memset(&r, 0, sizeof r);
    if (!CHECK_OK(ctx, gsf_nn_load_vae(ctx, model_folder(), &vae))) exit(1);
    float* clip = random_floats(&seed, (size_t)(3 * frames * height * width), 1.0);
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, &vae, GSF_NN_VAE_ENCODE, desc, frames, height, width, &r.encoded));
    const gsf_nn_vae_info e = r.encoded;
    r.latents = (size_t)(vae.latent_channels * e.frames * e.height * e.width);
    r.mean = (float*)calloc(r.latents, sizeof(float));
    r.logvar = (float*)calloc(r.latents, sizeof(float));
    CHECK_OK(ctx, gsf_nn_encode_vae(ctx, &vae, desc, clip, frames, height, width, r.mean, r.logvar));
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, &vae, GSF_NN_VAE_DECODE, desc, e.frames, e.height, e.width, &r.decoded));
    r.pixels = (size_t)(3 * r.decoded.frames * r.decoded.height * r.decoded.width);
    r.video = (float*)calloc(r.pixels, sizeof(float));
    CHECK_OK(ctx, gsf_nn_decode_vae(ctx, &vae, desc, r.mean, e.frames, e.height, e.width, r.video));
    free(clip);
    gsf_nn_destroy_vae(ctx, &vae);
    return r;
}

static void compare_results(const vae_result* a, const vae_result* b, double tolerance) {
    if (!CHECK(a->latents == b->latents && a->pixels == b->pixels)) return;
    if (tolerance == 0.0) {
        CHECK(memcmp(a->mean, b->mean, a->latents * sizeof(float)) == 0);
        CHECK(memcmp(a->logvar, b->logvar, a->latents * sizeof(float)) == 0);
        CHECK(memcmp(a->video, b->video, a->pixels * sizeof(float)) == 0);
    } else {
        CHECK(test_relative_error(a->mean, b->mean, a->latents) < tolerance);
        CHECK(test_relative_error(a->logvar, b->logvar, a->latents) < tolerance);
        CHECK(test_relative_error(a->video, b->video, a->pixels) < tolerance);
    }
}

// Channels, groups, levels and layers that differ from the golden model's: AVX2 against scalar, one worker against
// three.
static void test_levels_and_workers(void) {
    static const vae_shape shapes[] = {{{6, 12, 20, 0}, 3, 2, 1, 4, 4}, {{5, 10, 0, 0}, 2, 5, 2, 3, 2},
                                       {{16, 0, 0, 0}, 1, 1, 1, 2, 4}, {{8, 8, 16, 24}, 4, 4, 1, 5, 8}};
    static const int64_t sizes[][3] = {{9, 20, 28}, {17, 9, 7}, {3, 5, 6}, {2, 24, 8}};
    for (size_t i = 0; i < GSF__COUNT(shapes); i++) {
        gsf_context scalar, best, shuffled;
        vae_file* file = make_vae_file(&shapes[i]);
        memset(&scalar, 0, sizeof scalar);
        scalar.cpu_level = GSF_CPU_SCALAR;
        CHECK_OK(&scalar, gsf_init_context(&scalar));
        test_context_init(&best);
        test_context_zero(&shuffled);
        work_backwards(&shuffled);
        CHECK_OK(&shuffled, gsf_init_context(&shuffled));
        save_model(&best, &shapes[i], file);
        vae_result a = both_ways(&scalar, NULL, sizes[i][0], sizes[i][1], sizes[i][2]);
        vae_result b = both_ways(&best, NULL, sizes[i][0], sizes[i][1], sizes[i][2]);
        vae_result c = both_ways(&shuffled, NULL, sizes[i][0], sizes[i][1], sizes[i][2]);
        compare_results(&b, &a, 5e-6);
        compare_results(&c, &b, 0.0);
        free_result(&a), free_result(&b), free_result(&c);
        free_file(file);
    }
}

// ---- sizes, cost, tiles

static void test_sizes(gsf_context* ctx, const gsf_nn_vae* vae) {
    static const int64_t encoded[][2] = {{1, 1}, {2, 1}, {5, 2}, {7, 2}, {8, 2}, {9, 3}, {10, 3}, {13, 4}, {16, 4}, {17, 5},
                                         {23, 6}, {25, 7}, {49, 13}};
    static const int64_t decoded[][2] = {{1, 1}, {2, 8}, {3, 9}, {4, 16}, {5, 17}, {13, 49}};
    gsf_nn_vae_info info;
    for (size_t i = 0; i < GSF__COUNT(encoded); i++) {
        CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, NULL, encoded[i][0], 8, 12, &info));
        CHECK(info.frames == encoded[i][1] && info.height == 2 && info.width == 3);
    }
    for (size_t i = 0; i < GSF__COUNT(decoded); i++) {
        CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, NULL, decoded[i][0], 2, 3, &info));
        CHECK(info.frames == decoded[i][1] && info.height == 8 && info.width == 12);
    }
    CHECK_RESULT(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, NULL, 0, 2, 3, &info), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, NULL, 1, 3, 8, &info), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, NULL, INT64_MAX / 2, 1 << 30, 1 << 30, &info),
                 GSF_ERROR_INVALID_ARGUMENT);
}

typedef struct meter { size_t live, peak; } meter;

static void* metered_alloc(void* user, size_t size) {
    meter* m = (meter*)user;
    size_t* p = (size_t*)malloc(size + sizeof(size_t));
    if (!p) return NULL;
    *p = size;
    m->live += size;
    if (m->live > m->peak) m->peak = m->live;
    return p + 1;
}
static void metered_free(void* user, void* memory) {
    if (!memory) return;
    size_t* p = (size_t*)memory - 1;
    ((meter*)user)->live -= *p;
    free(p);
}

// A run takes the bytes that the query reports, apart from small allocations; more than max_bytes is refused.
static void test_vae_memory(void) {
    gsf_context ctx;
    gsf_nn_vae vae;
    meter m;
    memset(&m, 0, sizeof m);
    test_context_zero(&ctx);
    ctx.allocator.alloc_fn = metered_alloc;
    ctx.allocator.free_fn = metered_free;
    ctx.allocator.user = &m;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    CHECK_OK(&ctx, gsf_nn_load_vae(&ctx, model_folder(), &vae));
    for (int tiled = 0; tiled < 2; tiled++) {
        gsf_nn_vae_desc desc;
        gsf_nn_vae_info info;
        uint64_t seed = 5;
        memset(&desc, 0, sizeof desc);
        desc.tiled = tiled;
        desc.overlap_height = desc.overlap_width = 0.2, desc.tile_height = desc.tile_width = 20;
        CHECK_OK(&ctx, gsf_nn_query_vae(&ctx, &vae, GSF_NN_VAE_DECODE, &desc, 5, 13, 14, &info));
        float* latents = random_floats(&seed, 4 * 5 * 13 * 14, 1.0);
        float* video = (float*)malloc((size_t)(3 * info.frames * info.height * info.width) * sizeof(float));
        const size_t start = m.live;
        m.peak = start;
        CHECK_OK(&ctx, gsf_nn_decode_vae(&ctx, &vae, &desc, latents, 5, 13, 14, video));
        CHECK(m.live == start);
        CHECK((double)(m.peak - start) >= info.bytes && (double)(m.peak - start) <= info.bytes + 20000.0);
        desc.max_bytes = info.bytes - 1.0;
        CHECK_RESULT(&ctx, gsf_nn_decode_vae(&ctx, &vae, &desc, latents, 5, 13, 14, video), GSF_ERROR_OUT_OF_MEMORY);
        CHECK(strstr(ctx.error, "MiB") != NULL);
        free(latents);
        free(video);
    }
    gsf_nn_destroy_vae(&ctx, &vae);
    CHECK(m.live == 0);
}

static void test_tiles(gsf_context* ctx, const gsf_nn_vae* vae) {
    gsf_nn_vae_desc desc;
    gsf_nn_vae_info info, plain;
    gsf_context scalar;
    memset(&desc, 0, sizeof desc);
    memset(&scalar, 0, sizeof scalar);
    scalar.cpu_level = GSF_CPU_SCALAR;
    CHECK_OK(&scalar, gsf_init_context(&scalar));
    desc.tiled = 1; // 20 x 16 pixels; a sixth of 5 latents is not whole
    CHECK_RESULT(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, &desc, 2, 9, 9, &info), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx->error, "height") != NULL);
    desc.tile_height = 24;
    CHECK_RESULT(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, &desc, 2, 9, 9, &info), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(strstr(ctx->error, "width") != NULL);
    desc.tile_width = 20;
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, &desc, 5, 11, 14, &info));
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, NULL, 5, 11, 14, &plain));
    CHECK(info.chunks == 3 * 4 * 2 && info.frames == plain.frames && info.height == plain.height);
    CHECK(info.bytes < plain.bytes && info.flops > plain.flops);
    CHECK_RESULT(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, &desc, 5, 41, 44, &info), GSF_ERROR_INVALID_ARGUMENT);
    vae_result a = both_ways(&scalar, &desc, 5, 44, 56), b = both_ways(ctx, &desc, 5, 44, 56);
    vae_result whole = both_ways(ctx, NULL, 5, 44, 56);
    compare_results(&b, &a, 5e-6);
    CHECK(test_relative_error(b.mean, whole.mean, b.latents) > 1e-3);
    // An image no larger than a tile is not tiled.
    vae_result small = both_ways(ctx, &desc, 5, 24, 20), untiled = both_ways(ctx, NULL, 5, 24, 20);
    compare_results(&small, &untiled, 0.0);
    free_result(&a), free_result(&b), free_result(&whole), free_result(&small), free_result(&untiled);
}

// ---- damaged files

static void expect_bad(gsf_context* ctx, const vae_file* f, gsf_result code, const char* text) {
    gsf_nn_vae vae;
    if (f)
        CHECK_OK(ctx, gsf_nn_save_tensors(ctx, test_scratch("diffusion_pytorch_model.safetensors"), f->tensors, f->count));
    CHECK_RESULT(ctx, gsf_nn_load_vae(ctx, model_folder(), &vae), code);
    if (!CHECK(strstr(ctx->error, text) != NULL)) fprintf(stderr, "%s (wanted %s)\n", ctx->error, text);
}

static void test_bad_tensors(gsf_context* ctx) {
    vae_file* f = make_vae_file(&tiny_vae);
    gsf_nn_tensor *last = &f->tensors[f->count - 1], *t = file_tensor(f,
                                                                      "decoder.up_blocks.1.upsamplers.0.conv.weight");
    const gsf_nn_tensor kept = *t;
    save_model(ctx, &tiny_vae, f);
    t->shape[0]--;
    t->count = t->shape[0] * t->shape[1] * 9;
    expect_bad(ctx, f, GSF_ERROR_FORMAT, "decoder.up_blocks.1.upsamplers.0.conv.weight");
    *t = *last; // absent
    f->count--;
    expect_bad(ctx, f, GSF_ERROR_FORMAT, "decoder.up_blocks.1.upsamplers.0.conv.weight");
    f->tensors[f->count++] = kept;
    t->name = "decoder.surplus.weight";
    expect_bad(ctx, f, GSF_ERROR_FORMAT, "decoder.conv_out.conv.bias");
    t->name = "decoder.conv_out.conv.bias";
    f->tensors[f->count] = kept;
    f->tensors[f->count].name = "decoder.surplus.weight";
    f->count++;
    expect_bad(ctx, f, GSF_ERROR_FORMAT, "decoder.surplus.weight");
    f->tensors[--f->count].data = NULL;
    save_model(ctx, &tiny_vae, f);
    free_file(f);
}

static void test_vae_bad_configs(gsf_context* ctx) {
    static const struct { const char *more, *text; gsf_result code; } cases[] = {
        {", \"act_fn\": \"gelu\"", "act_fn", GSF_ERROR_UNSUPPORTED},
        {", \"use_quant_conv\": true", "quant_conv", GSF_ERROR_UNSUPPORTED},
        {", \"_class_name\": \"AutoencoderKL\"", "AutoencoderKL", GSF_ERROR_UNSUPPORTED},
        {", \"up_block_types\": [\"CogVideoXUpBlock3D\"]", "up_block_types", GSF_ERROR_UNSUPPORTED},
        {", \"in_channels\": 0", "in_channels", GSF_ERROR_FORMAT},
        {", \"norm_eps\": \"small\"", "norm_eps", GSF_ERROR_FORMAT},
        {", \"in_channels\": 4", "encoder.conv_in.conv.weight", GSF_ERROR_FORMAT},
    };
    for (size_t i = 0; i < GSF__COUNT(cases); i++) {
        save_config(ctx, &tiny_vae, cases[i].more);
        expect_bad(ctx, NULL, cases[i].code, cases[i].text);
    }
    vae_shape odd = tiny_vae;
    odd.groups = 4; // does not divide 6 channels
    save_config(ctx, &odd, "");
    expect_bad(ctx, NULL, GSF_ERROR_FORMAT, "norm_num_groups");
    save_config(ctx, &tiny_vae, "");
}

// ---- NaN, cancellation, out of memory

static int only_zeros(const float* x, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (x[i] != 0.0f) return 0;
    return 1;
}

static void test_nan(gsf_context* ctx) {
    enum { FRAMES = 5, SIDE = 3, PIXELS = 3 * 17 * 12 * 12 };
    static const char* const layers[] = {
        "decoder.conv_in.conv.bias", "decoder.up_blocks.1.resnets.0.norm2.conv_y.conv.weight",
        "decoder.up_blocks.2.resnets.1.conv2.conv.weight", "decoder.norm_out.norm_layer.bias"};
    static const char* const named[] = {"decoder.conv_in", "decoder.up_blocks.1.resnets.0.conv2",
                                        "decoder.up_blocks.2.resnets.1.conv2", "decoder.conv_out"};
    gsf_nn_vae vae;
    uint64_t seed = 9;
    float *latents = random_floats(&seed, 4 * FRAMES * SIDE * SIDE, 1.0), *video = (float*)malloc(PIXELS * sizeof(float));
    vae_file* f = make_vae_file(&tiny_vae);
    CHECK_OK(ctx, gsf_nn_load_vae(ctx, model_folder(), &vae));
    latents[2 * FRAMES * SIDE * SIDE + 4 * SIDE * SIDE + 1 * SIDE + 2] = NAN;
    CHECK_RESULT(ctx, gsf_nn_decode_vae(ctx, &vae, NULL, latents, FRAMES, SIDE, SIDE, video), GSF_ERROR_NUMERIC);
    CHECK(strstr(ctx->error, "channel 2, frame 4, row 1, column 2") != NULL);
    latents[2 * FRAMES * SIDE * SIDE + 4 * SIDE * SIDE + 1 * SIDE + 2] = 1e30f; // finite, but overflows later
    CHECK_RESULT(ctx, gsf_nn_decode_vae(ctx, &vae, NULL, latents, FRAMES, SIDE, SIDE, video), GSF_OK);
    latents[2 * FRAMES * SIDE * SIDE + 4 * SIDE * SIDE + 1 * SIDE + 2] = 3e38f;
    for (int i = 0; i < 4; i++) latents[(i * FRAMES + 4) * SIDE * SIDE + 5] = i % 2 ? -3.4e38f : 3.4e38f;
    memset(video, 1, PIXELS * sizeof(float));
    CHECK_RESULT(ctx, gsf_nn_decode_vae(ctx, &vae, NULL, latents, FRAMES, SIDE, SIDE, video), GSF_ERROR_NUMERIC);
    CHECK(strstr(ctx->error, "chunk 2 of 2") != NULL); // frame 4 of 5
    CHECK(only_zeros(video, PIXELS));
    gsf_nn_destroy_vae(ctx, &vae);
    for (int i = 0; i < 4; i++) latents[(i * FRAMES + 4) * SIDE * SIDE + 5] = 0.5f;
    latents[2 * FRAMES * SIDE * SIDE + 4 * SIDE * SIDE + 1 * SIDE + 2] = 0.5f;
    for (size_t i = 0; i < GSF__COUNT(layers); i++) {
        float* w = (float*)(uintptr_t)file_tensor(f, layers[i])->data;
        const float kept = w[1];
        w[1] = NAN;
        save_model(ctx, &tiny_vae, f);
        w[1] = kept;
        CHECK_OK(ctx, gsf_nn_load_vae(ctx, model_folder(), &vae));
        CHECK_RESULT(ctx, gsf_nn_decode_vae(ctx, &vae, NULL, latents, FRAMES, SIDE, SIDE, video), GSF_ERROR_NUMERIC);
        if (!CHECK(strstr(ctx->error, named[i]) != NULL)) fprintf(stderr, "%s (wanted %s)\n", ctx->error, named[i]);
        gsf_nn_destroy_vae(ctx, &vae);
    }
    save_model(ctx, &tiny_vae, f);
    free_file(f);
    free(latents);
    free(video);
}

typedef struct canceller { gsf_context* ctx; int calls; double done, total; } canceller;

static void cancel_soon(void* user, const char* stage, double done, double total) {
    canceller* c = (canceller*)user;
    (void)stage;
    CHECK(done > c->done && done <= total);
    c->done = done;
    c->total = total;
    if (++c->calls == 2) gsf_request_cancel(c->ctx);
}

static void test_vae_cancel(void) {
    gsf_context ctx;
    gsf_nn_vae vae;
    canceller c;
    uint64_t seed = 4;
    float *clip = random_floats(&seed, 3 * 33 * 8 * 8, 1.0), *mean = random_floats(&seed, 4 * 9 * 2 * 2, 1.0);
    memset(&c, 0, sizeof c);
    test_context_zero(&ctx);
    c.ctx = &ctx;
    ctx.progress.progress_fn = cancel_soon;
    ctx.progress.user = &c;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    CHECK_OK(&ctx, gsf_nn_load_vae(&ctx, model_folder(), &vae));
    CHECK_RESULT(&ctx, gsf_nn_encode_vae(&ctx, &vae, NULL, clip, 33, 8, 8, mean, NULL), GSF_ERROR_CANCELLED);
    CHECK(c.calls == 2 && c.total == 4.0);
    CHECK(only_zeros(mean, 4 * 9 * 2 * 2));
    gsf_clear_cancel(&ctx);
    c.done = 0.0;
    CHECK_OK(&ctx, gsf_nn_encode_vae(&ctx, &vae, NULL, clip, 33, 8, 8, mean, NULL));
    CHECK(c.done == 4.0);
    gsf_nn_destroy_vae(&ctx, &vae);
    free(clip);
    free(mean);
}

// Opening, and decoding in tiles, while allocation `fail_at` fails.
static gsf_result run_short_of_memory(counter* c) {
    gsf_context ctx;
    gsf_nn_vae vae;
    gsf_nn_vae_desc desc;
    float latents[4 * 4 * 6 * 2], video[3 * 16 * 24 * 8];
    memset(&desc, 0, sizeof desc);
    desc.tiled = 1;
    desc.tile_height = desc.tile_width = 20;
    desc.overlap_height = desc.overlap_width = 0.2;
    for (size_t i = 0; i < GSF__COUNT(latents); i++) latents[i] = (float)(i % 7) - 3.0f;
    test_context_zero(&ctx);
    count_memory(&ctx, c);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    gsf_result result = gsf_nn_load_vae(&ctx, model_folder(), &vae);
    if (result == GSF_OK) result = gsf_nn_decode_vae(&ctx, &vae, &desc, latents, 4, 6, 2, video);
    gsf_nn_destroy_vae(&ctx, &vae);
    CHECK(c->live == 0);
    return result;
}

static void test_no_memory(void) {
    counter all;
    memset(&all, 0, sizeof all);
    CHECK(run_short_of_memory(&all) == GSF_OK);
    for (size_t k = 1; k <= all.calls; k++) {
        counter c;
        memset(&c, 0, sizeof c);
        c.fail_at = k;
        const gsf_result result = run_short_of_memory(&c);
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY))
            fprintf(stderr, "allocation %zu: %s\n", k, gsf_describe_result(result));
    }
}

int main(void) {
    gsf_context ctx;
    gsf_nn_vae vae;
    test_context_zero(&ctx);
    ctx.logger.log_fn = keep_warning;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    test_convolve();
    test_maps();
    test_levels_and_workers();
    vae_file* file = make_vae_file(&tiny_vae);
    save_model(&ctx, &tiny_vae, file);
    free_file(file);
    CHECK_OK(&ctx, gsf_nn_load_vae(&ctx, model_folder(), &vae));
    test_sizes(&ctx, &vae);
    test_tiles(&ctx, &vae);
    gsf_nn_destroy_vae(&ctx, &vae);
    test_vae_memory();
    test_nan(&ctx);
    test_vae_cancel();
    test_no_memory();
    test_bad_tensors(&ctx);
    test_vae_bad_configs(&ctx);
    CHECK(warnings == 0);
    return test_report();
}
