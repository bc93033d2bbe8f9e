// bench_metrics.c - run time of the metrics on a clip of 720 x 480, with networks of their real sizes and random weights.
// By hand: cc -O2 -fopenmp -I. bench/bench_metrics.c -o bench_metrics -lm
//
//     bench_metrics [--json] [--quick] [--filter TEXT] [--threads N] [--frames N] [--models FOLDER]
//     bench_metrics --make FOLDER     only writes the weights, of networks an eighth as wide or less (for tests)
//
// A row is the whole clip: 49 frames, or N; with --quick 2 (motion smoothness: 3), and without the networks that take long. The
// weights are written to FOLDER (default: bench_metrics.models in the current folder) where they are missing, 1.3 GB for all of
// them. Reading them is not timed: one frame is measured before. peak_rss_bytes is that of the process so far.
// bench/peers_metrics.py runs the Python packages on the same cases.
#define GSFIXER_IMPLEMENTATION
#define GSF_ASSERT(x) ((void)0)
#include "../gsfixer_nn.h"

#include <sys/stat.h>

#define BENCH_NAME "metrics"
#include "bench.h"

enum { WIDTH = 720, HEIGHT = 480, TENSORS = 400 };

typedef struct bench_options {
    int json, quick, threads, frames;
    const char *filter, *models, *make;
} bench_options;

// ---- random weights -------------------------------------------------------------------

typedef struct bench_file { // tensors of a file
    gsf_context* ctx;
    gsf_nn_tensor tensors[TENSORS];
    char names[TENSORS][96];
    size_t count;
    uint64_t seed;
    int small; // instead of the published widths and depths
} bench_file;

// Adds a tensor of the shape given by up to four sizes, 0: none. Uniform, and such that a layer keeps the scale of its input.
static void add_tensor(bench_file* file, const char* name, int64_t a, int64_t b, int64_t c, int64_t d) {
    const int64_t shape[4] = {a, b, c, d};
    int32_t rank = 1;
    int64_t count = a, fan = 1;
    for (; rank < 4 && shape[rank]; rank++) {
        count *= shape[rank];
        fan *= shape[rank];
    }
    float* data = (float*)bench_alloc(file->ctx, (size_t)count, sizeof(float));
    const double most = rank == 1 ? 0.1 : sqrt(3.0 / (double)fan);
    const int is_scale = strstr(name, "norm") && strstr(name, "weight"); // of a norm
    const int is_head = strncmp(name, "lin", 3) == 0;                    // of LPIPS, where no weight is negative
    for (int64_t i = 0; i < count; i++) {
        const double x = most * (2.0 * gsf_draw_uniform(file->seed, file->count, (uint64_t)i) - 1.0);
        data[i] = (float)(is_scale ? 1.0 + x : is_head ? fabs(x) : x);
    }
    snprintf(file->names[file->count], sizeof file->names[0], "%s", name);
    file->tensors[file->count] = gsf_nn_wrap_tensor(file->names[file->count], data, rank, shape);
    file->count++;
}

static void add_layer(bench_file* file, const char* name, int64_t out, int64_t in, int64_t kernel) { // kernel 0: linear
    char full[96];
    snprintf(full, sizeof full, "%s.weight", name);
    add_tensor(file, full, out, in, kernel, kernel);
    snprintf(full, sizeof full, "%s.bias", name);
    add_tensor(file, full, out, 0, 0, 0);
}

static void save_file(bench_file* file, const char* folder, const char* name) {
    char path[1200];
    snprintf(path, sizeof path, "%s/%s.safetensors", folder, name);
    bench_require(file->ctx, gsf_nn_save_tensors(file->ctx, path, file->tensors, file->count));
    for (size_t i = 0; i < file->count; i++) gsf_free(file->ctx, (void*)(uintptr_t)file->tensors[i].data);
    file->count = 0;
}

static void make_lpips(bench_file* file, const char* folder, int kind) {
    static const int64_t outputs[3][17] = {{64, 0, 192, 0, 384, 256, 256}, {64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512,
                                            512, 0, 512, 512, 512}, {64, 0, 128, 128, 0, 256, 256, 0, 384, 384, 512, 512}};
    int64_t channels = 3, taps[GSF__LPIPS_TAPS];
    int count = 0;
    char name[96];
    for (int i = 0; gsf__lpips_nets[kind].steps[i].form; i++) {
        const gsf__lpips_step* s = &gsf__lpips_nets[kind].steps[i];
        const int64_t out = outputs[kind][i] / (file->small ? 8 : 1);
        snprintf(name, sizeof name, "features.%d", s->index);
        if (s->form == GSF__LPIPS_CONV) add_layer(file, name, out, channels, s->kernel);
        if (s->form == GSF__LPIPS_FIRE) { // squeezes to an eighth of what it returns
            snprintf(name, sizeof name, "features.%d.squeeze", s->index);
            add_layer(file, name, out / 8, channels, 1);
            snprintf(name, sizeof name, "features.%d.expand1x1", s->index);
            add_layer(file, name, out / 2, out / 8, 1);
            snprintf(name, sizeof name, "features.%d.expand3x3", s->index);
            add_layer(file, name, out / 2, out / 8, 3);
        }
        if (out) channels = out;
        if (s->tap) taps[count++] = channels;
    }
    save_file(file, folder, gsf__lpips_nets[kind].backbone);
    for (int i = 0; i < count; i++) {
        snprintf(name, sizeof name, "lin%d.model.1.weight", i);
        add_tensor(file, name, 1, taps[i], 1, 1);
    }
    save_file(file, folder, gsf__lpips_nets[kind].heads);
}

static int64_t tower_width(const bench_file* file) { return file->small ? 64 : 768; } // ViT-B/16
static int tower_layers(const bench_file* file) { return file->small ? 2 : 12; }

static void make_tower(bench_file* file, const char* folder, const gsf__tower_form* form) {
    const int64_t d = tower_width(file);
    char name[96];
    add_tensor(file, "cls_token", 1, 1, d, 0);
    add_tensor(file, "pos_embed", 1, 197, d, 0);
    add_layer(file, "patch_embed.proj", d, 3, 16);
    for (int i = 0; i < tower_layers(file); i++) {
        const struct { const char* name; int64_t out, in; } layers[] = {
            {"norm1", d, 0}, {"norm2", d, 0}, {"attn.qkv", 3 * d, d}, {"attn.proj", d, d}, {"mlp.fc1", 4 * d, d},
            {"mlp.fc2", d, 4 * d}};
        for (size_t k = 0; k < GSF__COUNT(layers); k++) {
            snprintf(name, sizeof name, "blocks.%d.%s", i, layers[k].name);
            add_layer(file, name, layers[k].out, layers[k].in, 0);
        }
    }
    add_layer(file, "norm", d, 0, 0);
    if (form->clip) {
        add_layer(file, "pos_drop", d, 0, 0);
        add_tensor(file, "proj", d, d * 2 / 3, 0, 0);
    }
    save_file(file, folder, form->file);
}

static void make_adapter(bench_file* file, const char* folder) { // LoRA of rank 16
    const int64_t d = tower_width(file);
    char path[1200], name[96];
    static const char config[] = "{\"r\": 16, \"lora_alpha\": 8}";
    snprintf(path, sizeof path, "%s/ensemble_lora", folder);
    (void)mkdir(path, 0777);
    for (int tower = 0; tower < 3; tower++)
        for (int i = 0; i < tower_layers(file); i++)
            for (int up = 0; up < 2; up++) {
                snprintf(name, sizeof name, "base_model.model.extractor_list.%d.model.blocks.%d.attn.qkv.lora_%c.weight", tower,
                         i, up ? 'B' : 'A');
                add_tensor(file, name, up ? 3 * d : 16, up ? 16 : d, 0, 0);
            }
    save_file(file, path, "adapter_model");
    snprintf(path, sizeof path, "%s/ensemble_lora/adapter_config.json", folder);
    bench_require(file->ctx, gsf_write_file(file->ctx, path, config, sizeof config - 1));
}

static void make_amt(bench_file* file, const char* folder) { // AMT-S
    const int64_t q = file->small ? 4 : 1, pyramid[5] = {3, 20 / q, 32 / q, 44 / q, 56 / q};
    const int64_t widths[4] = {32 / q, 32 / q, 64 / q, 96 / q};
    char name[96];
    add_layer(file, "feat_encoder.conv1", widths[0], 3, 7);
    for (int i = 0; i < 6; i++) {
        const int64_t out = widths[i / 2 + 1], in = i % 2 ? out : widths[i / 2];
        for (int k = 0; k < 3; k++) {
            snprintf(name, sizeof name, "feat_encoder.layer%d.%d.conv%d", i / 2 + 1, i % 2, k + 1);
            add_layer(file, name, k < 2 ? out / 4 : out, k ? out / 4 : in, k == 1 ? 3 : 1);
        }
        if (i != 2 && i != 4) continue;
        snprintf(name, sizeof name, "feat_encoder.layer%d.0.downsample.0", i / 2 + 1);
        add_layer(file, name, out, in, 1);
    }
    add_layer(file, "feat_encoder.conv2", 84 / q, widths[3], 1);
    for (int i = 0; i < 4; i++) {
        const int64_t c = pyramid[i + 1], wide = i == 3 ? 2 * c : 3 * c, in = i == 3 ? wide + 1 : wide + 4;
        for (int k = 0; k < 2; k++) {
            snprintf(name, sizeof name, "encoder.pyramid%d.%d.0", i + 1, k);
            add_layer(file, name, c, k ? c : pyramid[i], 3);
            snprintf(name, sizeof name, "encoder.pyramid%d.%d.1.weight", i + 1, k);
            add_tensor(file, name, c, 0, 0, 0);
        }
        snprintf(name, sizeof name, "decoder%d.convblock.0.0", i + 1);
        add_layer(file, name, wide, in, 3);
        snprintf(name, sizeof name, "decoder%d.convblock.0.1.weight", i + 1);
        add_tensor(file, name, wide, 0, 0, 0);
        for (int k = 1; k <= 5; k++) {
            const int64_t side = k == 2 || k == 4 ? 20 / q : wide; // the last 20 channels only
            snprintf(name, sizeof name, k < 5 ? "decoder%d.convblock.1.conv%d.0" : "decoder%d.convblock.1.conv%d", i + 1, k);
            add_layer(file, name, side, side, 3);
            snprintf(name, sizeof name, k < 5 ? "decoder%d.convblock.1.conv%d.1.weight" : "decoder%d.convblock.1.prelu.weight",
                     i + 1, k);
            add_tensor(file, name, side, 0, 0, 0);
        }
        const int64_t up = i ? pyramid[i] + 4 : 24;
        snprintf(name, sizeof name, "decoder%d.convblock.2.weight", i + 1);
        add_tensor(file, name, wide, up, 4, 4);
        snprintf(name, sizeof name, "decoder%d.convblock.2.bias", i + 1);
        add_tensor(file, name, up, 0, 0, 0);
        const int64_t f = pyramid[i];
        const struct { const char* name; int64_t out, in, kernel; } update[] = {
            {"convc1", 64 / q, 392, 1}, {"convf1", 40 / q, 4, 7}, {"convf2", 20 / q, 40 / q, 3}, {"conv", 68 / q, 84 / q, 3},
            {"gru.0", 76 / q, 68 / q + 4 + f, 3}, {"gru.2", 76 / q, 76 / q, 3}, {"feat_head.0", 76 / q, 76 / q, 3},
            {"feat_head.2", f, 76 / q, 3}, {"flow_head.0", 76 / q, 76 / q, 3}, {"flow_head.2", 4, 76 / q, 3}};
        for (size_t k = 0; i && k < GSF__COUNT(update); k++) {
            snprintf(name, sizeof name, "update%d.%s", i + 1, update[k].name);
            add_layer(file, name, update[k].out, update[k].in, update[k].kernel);
        }
    }
    add_layer(file, "comb_block.0", 18, 9, 3);
    add_tensor(file, "comb_block.1.weight", 18, 0, 0, 0);
    add_layer(file, "comb_block.2", 3, 18, 3);
    save_file(file, folder, "amt-s");
}

static int has_file(const char* folder, const char* name) {
    struct stat s;
    char path[1200];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    return stat(path, &s) == 0;
}

static void make_weights(gsf_context* ctx, const char* folder, int kind, int small) {
    static bench_file file;
    char name[96];
    file.ctx = ctx;
    file.small = small;
    file.count = 0;
    file.seed = (uint64_t)kind;
    (void)mkdir(folder, 0777);
    if (kind <= GSF_NN_METRIC_LPIPS_SQUEEZE) {
        snprintf(name, sizeof name, "%s.safetensors", gsf__lpips_nets[kind].heads);
        if (!has_file(folder, name)) make_lpips(&file, folder, kind);
    } else if (kind == GSF_NN_METRIC_MOTION_SMOOTHNESS) {
        if (!has_file(folder, "amt-s.safetensors")) make_amt(&file, folder);
    } else {
        for (int i = 0; i < (kind == GSF_NN_METRIC_I2V_BACKGROUND ? 3 : 1); i++) {
            snprintf(name, sizeof name, "%s.safetensors", gsf__i2v_background[i].file);
            if (!has_file(folder, name)) make_tower(&file, folder, &gsf__i2v_background[i]);
        }
        if (kind == GSF_NN_METRIC_I2V_BACKGROUND && !has_file(folder, "ensemble_lora/adapter_config.json"))
            make_adapter(&file, folder);
    }
}

// ---- cases ----------------------------------------------------------------------------

// A pan over waves: frame t, in 8 bits; `offset` makes another picture of the same scene.
static void draw_frame(uint8_t* out, int t, int offset) {
    for (int y = 0; y < HEIGHT; y++)
        for (int x = 0; x < WIDTH; x++)
            for (int c = 0; c < 3; c++) {
                const int u = x + 3 * t, waves = (u / (7 + c) % 9) * 12 + (y / (5 + c) % 7) * 14 + (u * y) % 23;
                *out++ = (uint8_t)((waves + offset * ((x * 31 + y * 17 + c * 7) % 13)) % 256);
            }
}

#define PIXELS(metric) (-1 - (int)GSF_METRIC_##metric) // the kind of a metric without a network

static void measure_frame(gsf_context* ctx, gsf_nn_metric* metric, int kind, const gsf_image* frame, const gsf_image* other) {
    double value;
    if (kind >= 0) bench_require(ctx, gsf_nn_measure_frame(ctx, metric, frame, other));
    else bench_require(ctx, gsf_measure_image(ctx, (gsf_metric)(-1 - kind), frame, other, NULL, &value));
}

static double peak_rss(void) { // of this program, in bytes; 0: unknown. ru_maxrss would include the one that started it
    char line[128];
    double kib = 0.0;
    FILE* file = fopen("/proc/self/status", "r");
    while (file && fgets(line, sizeof line, file)) (void)sscanf(line, "VmHWM: %lf", &kib);
    if (file) fclose(file);
    return 1024.0 * kib;
}

static void bench_one(const bench_options* o, int threads, const char* metric_name, int kind) {
    const int least = kind == GSF_NN_METRIC_MOTION_SMOOTHNESS ? 3 : 2;
    const int frames = o->frames > least ? o->frames : o->frames ? least : o->quick ? least : 49;
    uint8_t* bytes[2];
    char name[96];
    gsf_context ctx;
    gsf_nn_metric metric;
    snprintf(name, sizeof name, "%s %dx%d N=%d", metric_name, WIDTH, HEIGHT, frames);
    if ((o->filter && !strstr(name, o->filter)) || (o->threads && o->threads != threads)) return;
    if (o->quick && !o->filter && (kind == GSF_NN_METRIC_I2V_BACKGROUND || kind == GSF_NN_METRIC_LPIPS_VGG)) return;
    (void)bench_context(&ctx, GSF_CPU_AUTO, threads);
    memset(&metric, 0, sizeof metric);
    if (kind >= 0) {
        make_weights(&ctx, o->models, kind, 0);
        metric.kind = (gsf_nn_metric_kind)kind;
        metric.models = o->models;
    }
    for (int i = 0; i < 2; i++) bytes[i] = (uint8_t*)bench_alloc(&ctx, 3 * WIDTH * HEIGHT, 1);
    const gsf_image frame = gsf_wrap_image(bytes[0], GSF_U8, WIDTH, HEIGHT, 3);
    const gsf_image other = gsf_wrap_image(bytes[1], GSF_U8, WIDTH, HEIGHT, 3);
    double seconds = 0.0, cpu = 0.0;
    for (int t = -1; t < frames; t++) { // frame -1 reads the weights; of motion it is none of the clip
        draw_frame(bytes[0], t < 0 ? 0 : t, 0);
        draw_frame(bytes[1], t < 0 ? 0 : t, 1);
        if (t < 0 && kind == GSF_NN_METRIC_MOTION_SMOOTHNESS) {
            bench_require(&ctx, gsf_nn_measure_frame(&ctx, &metric, NULL, NULL));
            continue;
        }
        const double wall = bench_now(), used = bench_cpu();
        measure_frame(&ctx, &metric, kind, &frame, &other);
        if (t < 0) continue;
        seconds += bench_now() - wall;
        cpu += bench_cpu() - used;
    }
    bench_row row = bench_make_row(name, ctx.cpu_level, threads, seconds, cpu, frames, "frame");
    row.peak_rss = peak_rss();
    bench_print(o->json, &row);
    gsf_nn_destroy_metric(&ctx, &metric);
    for (int i = 0; i < 2; i++) gsf_free(&ctx, bytes[i]);
}

int main(int argc, char** argv) {
    static const struct { const char* name; int kind; } cases[] = {
        {"psnr", PIXELS(PSNR)}, {"ssim_3dgs", PIXELS(SSIM_3DGS)}, {"ssim_torchmetrics", PIXELS(SSIM_TORCHMETRICS)},
        {"ssim_skimage", PIXELS(SSIM_SKIMAGE)}, {"ms_ssim", PIXELS(MS_SSIM)},
        {"ms_ssim_torchmetrics", PIXELS(MS_SSIM_TORCHMETRICS)},
        {"temporal_flickering", PIXELS(DIFFERENCE)}, {"lpips_alex", GSF_NN_METRIC_LPIPS_ALEX},
        {"lpips_vgg", GSF_NN_METRIC_LPIPS_VGG}, {"lpips_squeeze", GSF_NN_METRIC_LPIPS_SQUEEZE},
        {"i2v_subject", GSF_NN_METRIC_I2V_SUBJECT}, {"i2v_background", GSF_NN_METRIC_I2V_BACKGROUND},
        {"motion_smoothness", GSF_NN_METRIC_MOTION_SMOOTHNESS}};
    bench_options o;
    memset(&o, 0, sizeof o);
    o.models = "bench_metrics.models";
    for (int i = 1; i < argc; i++) {
        const char* value = i + 1 < argc ? argv[i + 1] : NULL;
        if (strcmp(argv[i], "--json") == 0) o.json = 1;
        else if (strcmp(argv[i], "--quick") == 0) o.quick = 1;
        else if (value && strcmp(argv[i], "--filter") == 0) o.filter = argv[++i];
        else if (value && strcmp(argv[i], "--threads") == 0) o.threads = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--frames") == 0) o.frames = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--models") == 0) o.models = argv[++i];
        else if (value && strcmp(argv[i], "--make") == 0) o.make = argv[++i];
        else {
            fprintf(stderr, "usage: bench_metrics [--json] [--quick] [--filter TEXT] [--threads N] [--frames N] "
                            "[--models FOLDER | --make FOLDER]\n");
            return 2;
        }
    }
    if (o.make) {
        gsf_context ctx;
        (void)bench_context(&ctx, GSF_CPU_AUTO, 1);
        for (size_t i = 0; i < sizeof cases / sizeof *cases; i++)
            if (cases[i].kind >= 0) make_weights(&ctx, o.make, cases[i].kind, 1);
        return 0;
    }
    for (int threads = 1; threads <= 2; threads++)
        for (size_t i = 0; i < sizeof cases / sizeof *cases; i++) bench_one(&o, threads, cases[i].name, cases[i].kind);
    return 0;
}
