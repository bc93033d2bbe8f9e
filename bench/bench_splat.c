// bench_splat.c - run time and error of the splat code.
// By hand: cc -O2 -fopenmp -I. bench/bench_splat.c -o bench_splat -lm
//
//     bench_splat [--json] [--quick] [--filter TEXT] [--threads N]
//                 [--scene COLMAP [--views FILE] [--start PLY] [--steps N] [--isa scalar|avx2|avx512]]
//     bench_splat --growth [--json]
//     bench_splat --stereo COLMAP [--photos N] [--max-size PIXELS]
//
// Without a scene: the machine's peaks (multiply-adds per second; memory bandwidth by size of the buffer, when first
// needed), then, for synthetic splats at several sizes, each instruction set, and one and two threads: every stage of a
// training step, and complete forward and backward passes against the double-precision reference of
// tests/reference_splat.h where that is affordable. A pair is one splat blended into one pixel. Shares are relative to
// the peaks of the same instruction set and number of threads, for a buffer as large as the case's. With a scene:
// complete training steps (render, loss, backward, Adam; density control off) on its photos. --views is a text file of
// image names, one per line; --start a PLY to use instead of the scene's points. The first 5 steps are warm-up; the
// median, and the process' CPU seconds per step, are over the rest. --growth: how the cost of a step scales with the
// splats, with the pixels and with the share of the splats in the frame. --stereo: depth maps of a few training photos (3,
// at 240 pixels) against those that two more photos of the whole capture confirm, which the method itself finds: the share
// of pixels where such a depth is known; where the best plane, and where an accepted one, is right to 2 % there; how many of
// the accepted ones are; seconds. Means of two seeds.
#define _XOPEN_SOURCE 700 // getrusage
#define GSFIXER_IMPLEMENTATION
#define GSF_ASSERT(x) ((void)0)
#include "../gsfixer_splat.h"
#include "../tests/reference_splat.h"

#define BENCH_NAME "splat"
#include "bench.h"

#include <sys/resource.h>

typedef struct bench_options {
    int json, quick, growth, threads, steps, photos, max_size;
    gsf_cpu_level level; // of --scene
    const char *filter, *scene, *views, *start, *stereo;
} bench_options;

static void bench_show(const bench_options* o, const bench_row* row) {
    if (!o->filter || strstr(row->name, o->filter)) bench_print(o->json, row);
}

// ---- peaks of the machine -------------------------------------------------------

static void bench_machine(const bench_options* o, gsf_cpu_level level, int threads) {
    gsf_context ctx;
    double flops;
    if (!bench_context(&ctx, level, threads)) return;
    const gsf_chunk_fn fma = bench_fma_of(level, &flops);
    bench_peaks[level][threads].flops = bench_peak_rate(o->json, &ctx, "machine: multiply-add", fma, flops, "flop");
}

// ---- synthetic splats -----------------------------------------------------------

// A cloud that covers the image roughly evenly: anisotropic, half transparent, SH degree 3.
static void bench_make_splats(gsf_context* ctx, size_t count, double size, gsf_splats* s) {
    bench_require(ctx, gsf_splat_make(ctx, count, 3, s));
    for (size_t i = 0; i < count; i++) {
        for (uint64_t k = 0; k < 3; k++) {
            s->means[3 * i + k] = (float)((gsf_draw_uniform(1, k, i) * 2.0 - 1.0) * (k == 2 ? 1.0 : 2.0));
            s->log_scales[3 * i + k] = (float)(log(size) + 0.5 * gsf_draw_normal(2, k, i));
        }
        for (uint64_t k = 0; k < 4; k++) s->quats[4 * i + k] = (float)gsf_draw_normal(3, k, i);
        s->opacity_logits[i] = (float)gsf_draw_normal(4, 0, i);
        for (uint64_t k = 0; k < 48; k++) s->sh[48 * i + k] = (float)(0.2 * gsf_draw_normal(5, k, i));
    }
}

static gsf_camera bench_camera(int width, int height) {
    gsf_camera c;
    memset(&c, 0, sizeof c);
    for (int k = 0; k < 4; k++) c.w2c[5 * k] = 1.0;
    c.w2c[14] = 4.5;
    c.fx = c.fy = 0.9 * (width > height ? width : height);
    c.cx = 0.5 * width;
    c.cy = 0.5 * height;
    c.width = width;
    c.height = height;
    return c;
}

// ---- the stages of a step ---------------------------------------------------------

// Floating-point operations per pair, counted in the kernels' source (an FMA counts as two): position and exponent 6,
// 2^x 13, transmittance 4, colour 7; backward: the first three again, then the gradient of alpha 12 and ten sums 20.
#define BENCH_FORWARD_FLOPS 30.0
#define BENCH_BACKWARD_FLOPS 55.0

enum { STAGE_PROJECT, STAGE_BIN, STAGE_SORT, STAGE_BLEND, STAGE_LOSS, STAGE_REVERSE, STAGE_GATHER, STAGE_ADAM, STAGES };
static const char* const bench_stage_names[STAGES] = {"project", "bin", "sort", "blend", "loss", "reverse", "gather", "adam"};

typedef struct bench_count {
    gsf_rasterizer* r;
    gsf__raster_kernels kernels;
    uint64_t* pairs; // per tile
} bench_count;

// Pairs of one tile: lanes with an alpha, in the steps that the backward pass stores.
static void bench_count_tile(void* arg, size_t index, int32_t worker) {
    const bench_count* job = (const bench_count*)arg;
    const gsf__tile tile = gsf__tile_of(job->r, index);
    const gsf__worker_scratch* scratch = job->r->workers + worker;
    GSF__LINES float T[GSF__TILE_PIXELS];
    int columns, rows;
    gsf__tile_extent(job->r, &tile, &columns, &rows);
    gsf__open_tile(T, columns, rows);
    job->pairs[index] = 0;
    for (size_t next = 0, kept = 0; next < tile.count;) {
        next = job->kernels.keep(&tile, T, next, tile.count, scratch->steps, scratch->heads, &kept);
        for (size_t k = 0; k < kept; k++)
            for (int lane = 0; lane < 8; lane++) job->pairs[index] += scratch->steps[k].alpha[lane] > 0.0f;
    }
}

// Of the last render, whose backward pass has allocated the scratch memory.
static double bench_pairs(gsf_context* ctx, gsf_rasterizer* r) {
    const size_t tiles = (size_t)r->tiles_x * (size_t)r->tiles_y;
    bench_count job;
    job.r = r;
    job.kernels = gsf__raster_kernels_of(ctx->cpu_level > GSF_CPU_AVX2 ? GSF_CPU_AVX2 : ctx->cpu_level); // keep gsf__step
    job.pairs = (uint64_t*)gsf_alloc(ctx, tiles, sizeof(uint64_t));
    if (!job.pairs) exit(1);
    gsf__parallel_for(ctx, tiles, bench_count_tile, &job);
    double sum = 0.0;
    for (size_t t = 0; t < tiles; t++) sum += (double)job.pairs[t];
    gsf_free(ctx, job.pairs);
    return sum;
}

typedef struct bench_clock { double wall[STAGES], cpu[STAGES], wall_from, cpu_from; } bench_clock;

static void bench_lap(bench_clock* clock, int stage) { // assigns the time since the last lap to `stage`
    const double wall = bench_now(), cpu = bench_cpu();
    clock->wall[stage] = wall - clock->wall_from;
    clock->cpu[stage] = cpu - clock->cpu_from;
    clock->wall_from = bench_now();
    clock->cpu_from = bench_cpu();
}

// A training step stage by stage, as gsf_splat_render, gsf_splat_render_backward and the trainer run them.
static void bench_stages(const bench_options* o, const char* name, size_t count, double size, int width, int height,
                         gsf_cpu_level level, int threads) {
    gsf_context ctx;
    char label[80];
    int wanted = !o->filter;
    for (int k = 0; k <= STAGES && !wanted; k++) {
        snprintf(label, sizeof label, "%s: %s", name, k < STAGES ? bench_stage_names[k] : "step");
        wanted = strstr(label, o->filter) != NULL;
    }
    if (!wanted || !bench_context(&ctx, level, threads)) return;
    gsf_splats splats;
    bench_make_splats(&ctx, count, size, &splats);
    bench_require(&ctx, gsf_splat_sort(&ctx, &splats));
    const gsf_camera camera = bench_camera(width, height);
    const size_t pixels = (size_t)width * (size_t)height;
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    bench_require(&ctx, gsf_make_image(&ctx, GSF_F32, width, height, 3, &out.color));
    float* d_color = (float*)gsf_alloc_zeroed(&ctx, 3 * pixels, sizeof(float));
    float* photo = (float*)gsf_alloc(&ctx, 3 * pixels, sizeof(float));
    gsf__model model;
    memset(&model, 0, sizeof model);
    model.sh_degree = 3;
    bench_require(&ctx, gsf__model_reserve(&ctx, &model, count));
    model.count = count;
    float* const sources[GSF__GROUPS] = {splats.means, splats.log_scales, splats.quats, splats.opacity_logits, splats.sh};
    for (int g = 0; g < GSF__GROUPS; g++)
        memcpy(model.groups[g].value, sources[g], count * model.groups[g].width * sizeof(float));
    gsf_splats trained = splats;
    trained.means = model.groups[GSF__MEANS].value;
    trained.log_scales = model.groups[GSF__SCALES].value;
    trained.quats = model.groups[GSF__QUATS].value;
    trained.opacity_logits = model.groups[GSF__OPACITY].value;
    trained.sh = model.groups[GSF__SH].value;
    gsf_splat_grads grads;
    memset(&grads, 0, sizeof grads);
    grads.means = model.groups[GSF__MEANS].grad;
    grads.log_scales = model.groups[GSF__SCALES].grad;
    grads.quats = model.groups[GSF__QUATS].grad;
    grads.opacity_logits = model.groups[GSF__OPACITY].grad;
    grads.sh = model.groups[GSF__SH].grad;
    if (!d_color || !photo) exit(1);
    for (size_t i = 0; i < 3 * pixels; i++) photo[i] = (float)gsf_draw_uniform(7, 0, i);
    gsf_rasterizer* r;
    bench_require(&ctx, gsf_splat_make_rasterizer(&ctx, &r));
    // one step through the public functions allocates all buffers
    bench_require(&ctx, gsf_splat_render(&ctx, r, &trained, &camera, NULL, &out));
    bench_require(&ctx, gsf_splat_render_backward(&ctx, r, &trained, &camera, NULL, d_color, NULL, NULL, &grads));
    float* front = (float*)gsf_alloc(&ctx, 3 * pixels, sizeof(float));
    if (!front) exit(1);
    memcpy(front, out.color.data, 3 * pixels * sizeof(float));

    gsf_render_desc desc;
    memset(&desc, 0, sizeof desc);
    const gsf__view view = gsf__make_view(&trained, &camera, &desc);
    gsf__splat_loop project = {r, &view, &trained, NULL, &grads, ctx.cpu_level};
    gsf__raster_job raster;
    memset(&raster, 0, sizeof raster);
    raster.r = r;
    raster.kernels = gsf__raster_kernels_of(ctx.cpu_level);
    raster.view = &view;
    raster.out = &out;
    raster.d_color = d_color;
    gsf__loss_scratch scratch;
    gsf__target target;
    gsf__loss_value value;
    memset(&scratch, 0, sizeof scratch);
    memset(&target, 0, sizeof target);
    target.width = width;
    target.height = height;
    target.f32 = photo;
    gsf__adam_rates rates;
    memset(&rates, 0, sizeof rates); // full work with zero rates, so that every round has the same splats

    const size_t splat_chunks = gsf__splat_chunks(r);
    const size_t tiles = (size_t)r->tiles_x * (size_t)r->tiles_y;
    enum { MOST = 9 };
    const int rounds = o->quick ? 3 : MOST;
    double wall[STAGES][MOST], cpu[STAGES], step[MOST], step_cpu = 0.0, pairs = 0.0;
    memset(cpu, 0, sizeof cpu);
    for (int i = -1; i < rounds; i++) { // one warm-up round
        bench_clock clock;
        clock.wall_from = bench_now();
        clock.cpu_from = bench_cpu();
        gsf__parallel_for(&ctx, splat_chunks, gsf__project_chunk, &project);
        bench_lap(&clock, STAGE_PROJECT);
        bench_require(&ctx, gsf__order(&ctx, r));
        bench_lap(&clock, STAGE_SORT);
        bench_require(&ctx, gsf__bin(&ctx, r, &view));
        bench_lap(&clock, STAGE_BIN);
        gsf__parallel_for(&ctx, tiles, gsf__blend_chunk, &raster);
        bench_lap(&clock, STAGE_BLEND);
        bench_require(&ctx, gsf__loss(&ctx, &scratch, &target, (const float*)out.color.data, 0.2f, 1.0f, d_color, &value));
        bench_lap(&clock, STAGE_LOSS);
        if (r->entry_count) memset(r->slot_used, 0, r->entry_count);
        gsf__parallel_for(&ctx, tiles, gsf__reverse_chunk, &raster);
        bench_lap(&clock, STAGE_REVERSE);
        gsf__parallel_for(&ctx, splat_chunks, gsf__gather_chunk, &project);
        bench_lap(&clock, STAGE_GATHER);
        (void)gsf__adam_step(&ctx, &model, &rates, i + 2, 4);
        bench_lap(&clock, STAGE_ADAM);
        if (i < 0) continue;
        step[i] = 0.0;
        for (int k = 0; k < STAGES; k++) {
            wall[k][i] = clock.wall[k];
            cpu[k] += clock.cpu[k] / rounds;
            step[i] += clock.wall[k];
            step_cpu += clock.cpu[k] / rounds;
        }
    }
    if (memcmp(front, out.color.data, 3 * pixels * sizeof(float)) != 0) {
        fprintf(stderr, "bench_splat: the stages do not make the picture that gsf_splat_render makes\n");
        exit(1);
    }
    pairs = bench_pairs(&ctx, r);

    // minimum bytes that a stage transfers with cold caches: everything it reads and writes, once
    const double n = (double)count, entries = (double)r->entry_count, p = (double)pixels;
    const double bytes[STAGES] = {
        n * (59 * 4 + sizeof(gsf__record) + 4),
        n * (2 * sizeof(gsf__record) + 8) + entries * (4 + 8),
        n * (sizeof(gsf__record) + 8 + 4 * 3 * 8), // four passes that read the keys twice and write them once
        entries * sizeof(gsf__record) + p * (3 + 1) * 4,
        p * 3 * 4 * 3,
        entries * (2 * sizeof(gsf__record) + GSF__SLOT_FLOATS * 4) + p * 4 * 4,
        entries * (GSF__SLOT_FLOATS * 4 + 8) + n * (59 * 4 * 3 + sizeof(gsf__record)),
        n * 59 * 4 * 7,
    };
    for (int k = 0; k < STAGES; k++) {
        const int by_pair = k == STAGE_BLEND || k == STAGE_REVERSE, by_pixel = k == STAGE_LOSS;
        snprintf(label, sizeof label, "%s: %s", name, bench_stage_names[k]);
        bench_row row = bench_make_row(label, level, threads, bench_median(wall[k], (size_t)rounds), cpu[k],
                                       by_pair ? pairs : by_pixel ? p : n, by_pair ? "pairs" : by_pixel ? "pixels" : "splats");
        row.bytes = bytes[k];
        row.flops = k == STAGE_BLEND ? pairs * BENCH_FORWARD_FLOPS : k == STAGE_REVERSE ? pairs * BENCH_BACKWARD_FLOPS : 0.0;
        bench_show(o, &row);
    }
    snprintf(label, sizeof label, "%s: step", name);
    const bench_row row = bench_make_row(label, level, threads, bench_median(step, (size_t)rounds), step_cpu, n, "splats");
    bench_show(o, &row);
    gsf__loss_destroy_scratch(&ctx, &scratch);
    gsf__model_destroy(&ctx, &model);
    gsf_splat_destroy_rasterizer(&ctx, r);
    gsf_destroy_image(&ctx, &out.color);
    gsf_free(&ctx, front);
    gsf_free(&ctx, photo);
    gsf_free(&ctx, d_color);
    gsf_splat_destroy(&ctx, &splats);
}

// ---- renders against float64 -------------------------------------------------------

typedef struct bench_pass { // a forward and backward pass with its buffers
    gsf_rasterizer* r;
    gsf_camera camera;
    gsf_splats splats, sums; // sums: the gradients
    gsf_splat_grads grads;
    gsf_render_desc desc;
    gsf_render_output out;
    float* d_color;
    size_t values;           // values per image
} bench_pass;

static void bench_open_pass(gsf_context* ctx, bench_pass* p, size_t count, double size, int width, int height, double zoom) {
    memset(p, 0, sizeof *p);
    bench_make_splats(ctx, count, size, &p->splats);
    bench_require(ctx, gsf_splat_sort(ctx, &p->splats));
    bench_require(ctx, gsf_splat_make(ctx, count, 3, &p->sums));
    p->camera = bench_camera(width, height);
    p->camera.fx *= zoom;
    p->camera.fy *= zoom;
    p->values = 3 * (size_t)width * (size_t)height;
    p->d_color = (float*)gsf_alloc(ctx, p->values, sizeof(float));
    bench_require(ctx, gsf_make_image(ctx, GSF_F32, width, height, 3, &p->out.color));
    if (!p->d_color) exit(1);
    for (size_t i = 0; i < p->values; i++) p->d_color[i] = (float)gsf_draw_normal(6, 0, i);
    p->grads.means = p->sums.means;
    p->grads.log_scales = p->sums.log_scales;
    p->grads.quats = p->sums.quats;
    p->grads.opacity_logits = p->sums.opacity_logits;
    p->grads.sh = p->sums.sh;
    bench_require(ctx, gsf_splat_make_rasterizer(ctx, &p->r));
}

static void bench_close_pass(gsf_context* ctx, bench_pass* p) {
    gsf_splat_destroy_rasterizer(ctx, p->r);
    gsf_destroy_image(ctx, &p->out.color);
    gsf_free(ctx, p->d_color);
    gsf_splat_destroy(ctx, &p->sums);
    gsf_splat_destroy(ctx, &p->splats);
}

// One round: wall and CPU seconds of the forward, then of the backward pass.
static void bench_run_pass(gsf_context* ctx, bench_pass* p, double wall[2], double cpu[2]) {
    memset(p->sums.owned, 0, p->splats.count * (3 + 3 + 4 + 1 + 48) * sizeof(float));
    const double t0 = bench_now(), c0 = bench_cpu();
    bench_require(ctx, gsf_splat_render(ctx, p->r, &p->splats, &p->camera, &p->desc, &p->out));
    const double t1 = bench_now(), c1 = bench_cpu();
    bench_require(ctx, gsf_splat_render_backward(ctx, p->r, &p->splats, &p->camera, &p->desc, p->d_color, NULL, NULL,
                                                 &p->grads));
    wall[0] = t1 - t0;
    wall[1] = bench_now() - t1;
    cpu[0] = c1 - c0;
    cpu[1] = bench_cpu() - c1;
}

static void bench_error(const float* actual, const double* expected, const double* margin, size_t count, size_t per_pixel,
                        bench_row* row) {
    double worst = 0.0, difference = 0.0, total = 0.0;
    for (size_t i = 0; i < count; i++) {
        // A binary decision of this pixel is so close to its threshold that rounding may change it.
        if (margin && margin[i / per_pixel] < 1e-4) continue;
        const double d = fabs((double)actual[i] - expected[i]);
        if (d > worst) worst = d;
        difference += d * d;
        total += expected[i] * expected[i];
    }
    row->error_max = worst;
    row->error_rel_l2 = total > 0.0 ? sqrt(difference / total) : 0.0;
}

static void bench_render(const bench_options* o, const char* name, size_t count, double size, int width, int height,
                         gsf_cpu_level level, int threads, int with_reference) {
    char forward_name[64], backward_name[64];
    snprintf(forward_name, sizeof forward_name, "forward %s", name);
    snprintf(backward_name, sizeof backward_name, "backward %s", name);
    // the reference is slow
    if (o->filter && !strstr(forward_name, o->filter) && !strstr(backward_name, o->filter)) return;
    gsf_context ctx;
    if (!bench_context(&ctx, level, threads)) return;

    bench_pass p;
    bench_open_pass(&ctx, &p, count, size, width, height, 1.0);

    enum { MOST = 15 };
    double forward[MOST], backward[MOST], cpu[2] = {0.0, 0.0};
    const int rounds = o->quick ? 5 : MOST;
    for (int i = -1; i < rounds; i++) { // one warm-up round
        double wall[2], seconds[2];
        bench_run_pass(&ctx, &p, wall, seconds);
        if (i < 0) continue;
        forward[i] = wall[0];
        backward[i] = wall[1];
        for (int k = 0; k < 2; k++) cpu[k] += seconds[k] / rounds;
    }
    bench_row rows[2];
    for (int k = 0; k < 2; k++)
        rows[k] = bench_make_row(k ? backward_name : forward_name, level, threads,
                                 bench_median(k ? backward : forward, (size_t)rounds), cpu[k],
                                 bench_pairs(&ctx, p.r), "pairs");
    if (with_reference) {
        ref_splats exact = ref_splats_from(&p.splats);
        ref_options options = ref_options_from(NULL);
        ref_image image = ref_render(&exact, &p.camera, &options);
        double* d_wide = (double*)malloc(p.values * sizeof(double));
        if (!d_wide) exit(1);
        double blended = 0.0;
        for (size_t i = 0; i < p.values; i++) d_wide[i] = (double)p.d_color[i];
        for (size_t i = 0; i < p.values / 3; i++) blended += image.blended[i];
        ref_grads expected = ref_make_grads(exact.count, exact.sh_count);
        ref_render_backward(&exact, &p.camera, &options, &image, d_wide, NULL, NULL, &expected);
        bench_error((const float*)p.out.color.data, image.color, image.margin, p.values, 3, &rows[0]);
        bench_error(p.sums.means, expected.means, NULL, 3 * count, 1, &rows[1]);
        for (int k = 0; k < 2; k++) {
            rows[k].work = blended; // counted by the reference
            rows[k].reference = "float64";
        }
        free(d_wide);
        ref_destroy_grads(&expected);
        ref_destroy_image(&image);
        ref_destroy_splats(&exact);
    }
    for (int k = 0; k < 2; k++) bench_show(o, &rows[k]);
    bench_close_pass(&ctx, &p);
}

// ---- skipped work -------------------------------------------------------------------

// Forward and backward with and without a skip, alternating; the error is that of the image relative to the first
// variant.
static void bench_skips(const bench_options* o, const char* name, size_t count, double size, int width, int height,
                        int threads) {
    enum { FULL, OFFICIAL, SHUFFLED, VARIANTS, MOST = 9 };
    static const char* const labels[VARIANTS] = {"default", "footprint: official tiles only", "order: shuffled"};
    char label[96];
    snprintf(label, sizeof label, "skip: render and backward %s", name);
    if (o->filter && !strstr(label, o->filter)) return;
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = threads;
    bench_require(&ctx, gsf_init_context(&ctx));
    bench_pass passes[VARIANTS];
    for (int k = 0; k < VARIANTS; k++) bench_open_pass(&ctx, &passes[k], count, size, width, height, 1.0);
    passes[OFFICIAL].desc.footprint = GSF_FOOTPRINT_OFFICIAL;
    gsf_splat_destroy(&ctx, &passes[SHUFFLED].splats);
    bench_make_splats(&ctx, count, size, &passes[SHUFFLED].splats);
    double seconds[VARIANTS][MOST], cpu[VARIANTS] = {0.0};
    const int rounds = o->quick ? 3 : MOST;
    for (int i = -1; i < rounds; i++)
        for (int k = 0; k < VARIANTS; k++) {
            double wall[2], used[2];
            bench_run_pass(&ctx, &passes[k], wall, used);
            if (i < 0) continue;
            seconds[k][i] = wall[0] + wall[1];
            cpu[k] += (used[0] + used[1]) / rounds;
        }
    double* full = (double*)malloc(passes[FULL].values * sizeof(double));
    if (!full) exit(1);
    for (size_t i = 0; i < passes[FULL].values; i++) full[i] = (double)((const float*)passes[FULL].out.color.data)[i];
    for (int k = 0; k < VARIANTS; k++) {
        bench_row row = bench_make_row(label, ctx.cpu_level, threads, bench_median(seconds[k], (size_t)rounds), cpu[k],
                                       bench_pairs(&ctx, passes[k].r), "pairs");
        row.variant = labels[k];
        if (k != FULL) {
            bench_error((const float*)passes[k].out.color.data, full, NULL, passes[k].values, 1, &row);
            row.reference = "default";
        }
        bench_show(o, &row);
    }
    free(full);
    for (int k = 0; k < VARIANTS; k++) bench_close_pass(&ctx, &passes[k]);
}

// ---- lazy Adam --------------------------------------------------------------------

// Training steps with dense and with lazy Adam, alternating, on five views that see different parts of the splats if
// `zoom` is above 1. The splats are in Morton or in random order. Catching up counts as part of the step, not of its
// Adam stage. The error is that of the SH relative to the dense trainer's after all steps: the largest, relative to at
// least 0.2, and in L2.
static void bench_lazy(const bench_options* o, const char* size_name, size_t count, double size, int width, int height,
                       double zoom, int in_order, int rounds, int threads) {
    if (o->filter && !strstr("lazy: adam step", o->filter)) return;
    enum { VIEWS = 5, MOST = 400 };
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = threads;
    bench_require(&ctx, gsf_init_context(&ctx));
    gsf_splats splats;
    bench_make_splats(&ctx, count, size, &splats);
    if (in_order) bench_require(&ctx, gsf_splat_sort(&ctx, &splats));
    gsf_train_view views[VIEWS];
    memset(views, 0, sizeof views);
    for (uint64_t v = 0; v < VIEWS; v++) {
        gsf_camera* c = &views[v].camera;
        *c = bench_camera(width, height);
        c->fx *= zoom;
        c->fy *= zoom;
        c->cx += 0.25 * width * (zoom - 1.0) * ((double)v - 2.0);
        bench_require(&ctx, gsf_make_image(&ctx, GSF_U8, width, height, 3, &views[v].image));
        for (size_t i = 0; i < 3 * (size_t)width * (size_t)height; i++)
            ((uint8_t*)views[v].image.data)[i] = (uint8_t)(gsf_draw_bits(8, v, i) & 255u);
    }
    gsf_trainer* trainers[2]; // dense, lazy
    for (int k = 0; k < 2; k++) {
        gsf_train_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.densify_until = -1;
        desc.sh_interval = 1;
        desc.lazy_adam = k;
        bench_require(&ctx, gsf_splat_make_trainer(&ctx, &desc, views, VIEWS, &splats, &trainers[k]));
    }
    double adam[2][MOST], step[2][MOST], cpu[2][2] = {{0.0, 0.0}, {0.0, 0.0}}, drawn = 0.0;
    if (rounds > MOST) rounds = MOST;
    for (int i = -2 * VIEWS; i < rounds; i++)
        for (int turn = 0; turn < 2; turn++) {
            const int k = turn ^ (i & 1); // alternates which one runs first
            gsf_trainer* trainer = trainers[k];
            gsf__visit_job visits;
            gsf_train_stats stats;
            memset(&visits, 0, sizeof visits);
            memset(&stats, 0, sizeof stats);
            const double t0 = bench_now(), c0 = bench_cpu();
            bench_require(&ctx, gsf__trainer_gradients(&ctx, trainer, trainer->iteration + 1, &visits, &stats));
            const double t1 = bench_now(), c1 = bench_cpu();
            gsf__trainer_update(&ctx, trainer, ++trainer->iteration);
            if (i < 0) continue;
            adam[k][i] = bench_now() - t1;
            step[k][i] = bench_now() - t0;
            cpu[k][0] += (bench_cpu() - c1) / rounds;
            cpu[k][1] += (bench_cpu() - c0) / rounds;
            for (size_t j = 0; k == 0 && j < count; j++) drawn += trainer->rasterizer->radii[j] > 0 ? 1.0 / rounds : 0.0;
        }
    const gsf_splats* shown[2] = {gsf_splat_get_trained(trainers[0]), gsf_splat_get_trained(trainers[1])};
    double worst = 0.0, difference = 0.0, total = 0.0;
    for (size_t i = 0; i < 48 * count; i++) {
        const double a = (double)shown[0]->sh[i], d = (double)shown[1]->sh[i] - a;
        worst = fmax(worst, fabs(d) / fmax(fabs(a), 0.2));
        difference += d * d;
        total += a * a;
    }
    for (int stage = 0; stage < 2; stage++)
        for (int k = 0; k < 2; k++) {
            char label[96];
            snprintf(label, sizeof label, "lazy: %s %s, %.0f %% drawn%s", stage ? "step" : "adam", size_name,
                     100.0 * drawn / (double)count, in_order ? "" : ", shuffled");
            bench_row row = bench_make_row(label, ctx.cpu_level, threads,
                                           bench_median(stage ? step[k] : adam[k], (size_t)rounds), cpu[k][stage],
                                           (double)count, "splats");
            row.variant = k ? "lazy" : "dense";
            row.reference = k ? "dense" : "none";
            if (k) {
                row.error_max = worst;
                row.error_rel_l2 = sqrt(difference / total);
            }
            bench_show(o, &row);
        }
    for (int k = 0; k < 2; k++) gsf_splat_destroy_trainer(&ctx, trainers[k]);
    for (int v = 0; v < VIEWS; v++) gsf_destroy_image(&ctx, &views[v].image);
    gsf_splat_destroy(&ctx, &splats);
}

// ---- growth -----------------------------------------------------------------------

// Forward and backward with splats that shrink as their number grows, so that the number that overlaps a pixel stays
// about the same; `zoom` magnifies the image, so that fewer of the splats are in it.
static void bench_growth_row(const bench_options* o, const char* by, double amount, size_t count, int width, int height,
                             double zoom) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = o->threads;
    bench_require(&ctx, gsf_init_context(&ctx));
    bench_pass p;
    bench_open_pass(&ctx, &p, count, 2.0 / sqrt((double)count), width, height, zoom);
    enum { ROUNDS = 7 };
    double seconds[ROUNDS], cpu = 0.0;
    for (int i = -1; i < ROUNDS; i++) { // one warm-up round
        double wall[2], used[2];
        bench_run_pass(&ctx, &p, wall, used);
        if (i < 0) continue;
        seconds[i] = wall[0] + wall[1];
        cpu += (used[0] + used[1]) / ROUNDS;
    }
    char label[64];
    snprintf(label, sizeof label, "growth: %s %g", by, amount);
    bench_row row = bench_make_row(label, ctx.cpu_level, ctx.parallel.worker_count, bench_median(seconds, ROUNDS), cpu,
                                   amount, by);
    bench_show(o, &row);
    bench_close_pass(&ctx, &p);
}

static void bench_growth(const bench_options* o) {
    static const size_t counts[] = {1000, 3000, 10000, 30000, 100000, 300000, 1000000};
    static const int heights[] = {68, 135, 270, 540, 1080, 2160};
    static const double zooms[] = {1.0, 2.0, 4.0, 8.0, 16.0};
    for (size_t k = 0; k < GSF__COUNT(counts); k++)
        bench_growth_row(o, "splats", (double)counts[k], counts[k], 960, 540, 1.0);
    for (size_t k = 0; k < GSF__COUNT(heights); k++)
        bench_growth_row(o, "pixels", heights[k] * (heights[k] * 16 / 9), 100000, heights[k] * 16 / 9, heights[k], 1.0);
    for (size_t k = 0; k < GSF__COUNT(zooms); k++)
        bench_growth_row(o, "zoom", zooms[k], 300000, 960, 540, zooms[k]);
}

// ---- visible points ---------------------------------------------------------------

// 125 balls of points in a 5 x 5 x 5 grid, nearly touching, seen from an arc of 60 degrees: no view shows the back
// sides, and the front balls occlude most of the others, so that about 30 % of the points are visible.
static void bench_visibility(const bench_options* o, const char* name, size_t count, size_t view_count, int threads) {
    if (o->filter && !strstr(name, o->filter)) return;
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = threads;
    bench_require(&ctx, gsf_init_context(&ctx));
    gsf_scene scene;
    memset(&scene, 0, sizeof scene);
    scene.view_count = view_count;
    scene.point_count = count;
    scene.views = (gsf_scene_view*)gsf_alloc_zeroed(&ctx, view_count, sizeof(gsf_scene_view));
    scene.points = (double*)gsf_alloc(&ctx, 3 * count, sizeof(double));
    scene.track_begin = (size_t*)gsf_alloc_zeroed(&ctx, count + 1, sizeof(size_t));
    uint32_t* views = (uint32_t*)gsf_alloc(&ctx, view_count, sizeof(uint32_t));
    uint8_t* keep = (uint8_t*)gsf_alloc(&ctx, count, 1);
    if (!scene.views || !scene.points || !scene.track_begin || !views || !keep) exit(1);
    for (size_t i = 0; i < count; i++) {
        double d[3], length2 = 0.0;
        for (uint64_t k = 0; k < 3; k++) {
            d[k] = gsf_draw_normal(11, k, i);
            length2 += d[k] * d[k];
        }
        const uint64_t ball = gsf_draw_bits(12, 0, i) % 125;
        const double centre[3] = {(double)(ball % 5) - 2.0, (double)(ball / 5 % 5) - 2.0, (double)(ball / 25) - 2.0};
        for (int k = 0; k < 3; k++) scene.points[3 * i + (size_t)k] = centre[k] + 0.48 * d[k] / sqrt(length2);
    }
    for (size_t v = 0; v < view_count; v++) {
        const double angle = 1.0471976 * ((double)v + 0.5) / (double)view_count, up[3] = {0.0, -1.0, 0.0};
        const double eye[3] = {10.0 * cos(angle), -3.0, 10.0 * sin(angle)}, target[3] = {0.0, 0.0, 0.0};
        double pose[16];
        bench_require(&ctx, gsf_traj_look_at(&ctx, eye, target, up, pose));
        gsf_camera* c = &scene.views[v].camera;
        *c = bench_camera(1600, 1200);
        c->fx = c->fy = 1600.0;
        gsf_set_camera_c2w(c, pose);
        views[v] = (uint32_t)v;
    }
    gsf_visibility_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.method = GSF_VISIBILITY_RAYS;
    gsf_visibility_stats stats;
    const double cpu = bench_cpu();
    bench_require(&ctx, gsf_splat_filter_points(&ctx, &scene, views, view_count, &desc, keep, &stats));
    const double cpu_seconds = bench_cpu() - cpu;
    const char* by = stats.used_embree ? "embree" : "cells";
    char label[96];
    snprintf(label, sizeof label, "%s: normals", name);
    bench_row row = bench_make_row(label, ctx.cpu_level, threads, stats.seconds_normals, cpu_seconds, (double)count, "points");
    row.variant = by;
    bench_show(o, &row);
    snprintf(label, sizeof label, "%s: build and rays", name);
    row = bench_make_row(label, ctx.cpu_level, threads, stats.seconds_build + stats.seconds_rays, cpu_seconds,
                         (double)count * (double)view_count, "point views");
    row.variant = by;
    bench_show(o, &row);
    if (!o->json) printf("%s: by %s, %.1f %% of the points kept, %.3g rays, %.2f s to build\n", name, by,
                         100.0 * (double)stats.kept / (double)count, (double)stats.rays, stats.seconds_build);
    gsf_free(&ctx, keep);
    gsf_free(&ctx, views);
    gsf_free(&ctx, scene.track_begin);
    gsf_free(&ctx, scene.points);
    gsf_free(&ctx, scene.views);
}

// ---- training steps on photos -----------------------------------------------------

static int bench_listed(const char* list, const char* name) { // is `name` a line of `list`?
    const size_t length = strlen(name);
    for (const char* p = list; p && *p; p = strchr(p, '\n') ? strchr(p, '\n') + 1 : NULL)
        if (strncmp(p, name, length) == 0 && (p[length] == '\n' || p[length] == '\r' || p[length] == 0)) return 1;
    return list == NULL;
}

static void bench_training(const bench_options* o) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = o->threads;
    ctx.cpu_level = o->level;
    bench_require(&ctx, gsf_init_context(&ctx));
    gsf_scene scene;
    bench_require(&ctx, gsf_splat_load_scene(&ctx, o->scene, NULL, &scene));
    void* list = NULL;
    size_t list_size = 0;
    if (o->views) bench_require(&ctx, gsf_read_file(&ctx, o->views, &list, &list_size));
    gsf_train_view* views = (gsf_train_view*)gsf_alloc_zeroed(&ctx, scene.view_count + 1, sizeof *views);
    size_t count = 0;
    for (size_t i = 0; views && i < scene.view_count; i++) {
        if (!bench_listed((const char*)list, scene.views[i].name)) continue;
        bench_require(&ctx, gsf_splat_load_view_image(&ctx, &scene, i));
        views[count].camera = scene.views[i].camera;
        views[count++].image = scene.views[i].image;
    }
    gsf_splats start;
    if (o->start) bench_require(&ctx, gsf_splat_load(&ctx, o->start, &start));
    else
        bench_require(&ctx, gsf_splat_make_from_points(&ctx, scene.points, scene.colors, scene.point_count, NULL, 3,
                                                       scene.origin, &start));
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 30000;
    desc.sh_interval = 1; // all bands from the first step
    desc.densify_until = -1;
    desc.opacity_reset_interval = -1;
    gsf_trainer* trainer;
    bench_require(&ctx, gsf_splat_make_trainer(&ctx, &desc, views, count, &start, &trainer));

    double* seconds = (double*)gsf_alloc(&ctx, (size_t)o->steps, sizeof(double));
    if (!seconds) exit(1);
    gsf_train_stats stats;
    for (int i = 0; i < 5; i++) bench_require(&ctx, gsf_splat_step_trainer(&ctx, trainer, &stats));
    const double cpu = bench_cpu();
    for (int i = 0; i < o->steps; i++) {
        const double t = bench_now();
        bench_require(&ctx, gsf_splat_step_trainer(&ctx, trainer, &stats));
        seconds[i] = bench_now() - t;
    }
    const double step_cpu = (bench_cpu() - cpu) / o->steps;
    bench_row row = bench_make_row("train step", ctx.cpu_level, ctx.parallel.worker_count,
                                   bench_median(seconds, (size_t)o->steps), step_cpu, (double)start.count, "splats");
    struct rusage usage;
    if (getrusage(RUSAGE_SELF, &usage) == 0) row.peak_rss = 1024.0 * (double)usage.ru_maxrss; // KiB on Linux
    bench_show(o, &row);
    gsf_free(&ctx, seconds);
    gsf_splat_destroy_trainer(&ctx, trainer);
    gsf_splat_destroy(&ctx, &start);
    gsf_free(&ctx, views);
    gsf_free(&ctx, list);
    gsf_splat_destroy_scene(&ctx, &scene);
}

// ---- stereo -----------------------------------------------------------------------

typedef struct bench_depths { size_t pixels, known, accepted, compared, right; } bench_depths;

static const gsf_dense_map* bench_map_of(const gsf_dense* dense, uint32_t view) {
    for (size_t m = 0; m < dense->map_count; m++)
        if (dense->maps[m].view == view) return &dense->maps[m];
    return NULL;
}

static void bench_compare_depths(const gsf_dense* few, const gsf_dense* all, bench_depths* sums) {
    for (size_t m = 0; m < few->map_count; m++) {
        const gsf_dense_map *map = &few->maps[m], *truth = bench_map_of(all, map->view);
        for (int k = 0; truth && k < map->camera.width * map->camera.height; k++) {
            const float z = map->depth[k], t = truth->depth[k];
            sums->pixels++;
            sums->known += t > 0.0f;
            sums->accepted += z > 0.0f;
            sums->compared += z > 0.0f && t > 0.0f;
            sums->right += z > 0.0f && t > 0.0f && fabsf(z - t) < 0.02f * t;
        }
    }
}

static void bench_stereo(const bench_options* o) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.threads = o->threads;
    bench_require(&ctx, gsf_init_context(&ctx));
    gsf_scene scene;
    gsf_scene_desc scene_desc;
    memset(&scene_desc, 0, sizeof scene_desc);
    scene_desc.max_size = o->max_size;
    bench_require(&ctx, gsf_splat_load_scene(&ctx, o->stereo, &scene_desc, &scene));
    const size_t n = scene.view_count;
    uint32_t* every = (uint32_t*)gsf_alloc(&ctx, n + 1, sizeof(uint32_t));
    uint32_t* train = (uint32_t*)gsf_alloc(&ctx, n + 1, sizeof(uint32_t));
    uint8_t* keep = (uint8_t*)gsf_alloc(&ctx, scene.point_count + 1, 1);
    if (!every || !train || !keep) exit(1);
    size_t count = 0;
    for (size_t i = 0; i < n; i++) {
        every[i] = (uint32_t)i;
        bench_require(&ctx, gsf_splat_load_view_image(&ctx, &scene, i));
    }
    gsf_splat_split_views(n, 8, (size_t)o->photos, train, &count, NULL, NULL);
    bench_require(&ctx, gsf_splat_filter_points(&ctx, &scene, train, count, NULL, keep, NULL));
    gsf_dense_desc desc;
    gsf_dense all, few;
    memset(&desc, 0, sizeof desc);
    desc.want_maps = 1;
    desc.sources = 8;
    desc.min_consistent = 2;
    desc.seed = 77;
    bench_require(&ctx, gsf_splat_make_dense(&ctx, &scene, every, n, NULL, &desc, &all, NULL));
    bench_depths best, accepted;
    memset(&best, 0, sizeof best);
    memset(&accepted, 0, sizeof accepted);
    double seconds = 0.0;
    for (uint64_t run = 0; run < 4; run++) {
        memset(&desc, 0, sizeof desc);
        desc.want_maps = 1;
        desc.seed = 1 + run / 2;
        if (run & 1) { // whatever the views think of it
            desc.max_cost = desc.max_cost_many = 1.999f;
            desc.max_reprojection = desc.max_depth_error = 1e9f;
            desc.max_normal_angle = 180.0f;
        }
        const double start = bench_now();
        bench_require(&ctx, gsf_splat_make_dense(&ctx, &scene, train, count, keep, &desc, &few, NULL));
        if (!(run & 1)) seconds += 0.5 * (bench_now() - start);
        bench_compare_depths(&few, &all, run & 1 ? &best : &accepted);
        gsf_splat_destroy_dense(&ctx, &few);
    }
    printf("stereo of %zu photos: known %.1f %%, of these the best plane right %.1f %%, accepted and right %.1f %%; "
           "of the accepted %.1f %% right; %.2f s\n", count, 100.0 * (double)accepted.known / (double)accepted.pixels,
           100.0 * (double)best.right / (double)best.known, 100.0 * (double)accepted.right / (double)accepted.known,
           100.0 * (double)accepted.right / (double)accepted.compared, seconds);
    gsf_splat_destroy_dense(&ctx, &all);
    gsf_free(&ctx, keep);
    gsf_free(&ctx, train);
    gsf_free(&ctx, every);
    gsf_splat_destroy_scene(&ctx, &scene);
}

int main(int argc, char** argv) {
    bench_options o;
    memset(&o, 0, sizeof o);
    o.steps = 200;
    o.photos = 3;
    o.max_size = 240;
    for (int i = 1; i < argc; i++) {
        const char* value = i + 1 < argc ? argv[i + 1] : NULL;
        if (strcmp(argv[i], "--json") == 0) o.json = 1;
        else if (strcmp(argv[i], "--quick") == 0) o.quick = 1;
        else if (strcmp(argv[i], "--growth") == 0) o.growth = 1;
        else if (value && strcmp(argv[i], "--filter") == 0) o.filter = argv[++i];
        else if (value && strcmp(argv[i], "--threads") == 0) o.threads = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--scene") == 0) o.scene = argv[++i];
        else if (value && strcmp(argv[i], "--views") == 0) o.views = argv[++i];
        else if (value && strcmp(argv[i], "--start") == 0) o.start = argv[++i];
        else if (value && strcmp(argv[i], "--steps") == 0 && atoi(value) > 0) o.steps = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--isa") == 0 && bench_level_of(value) != GSF_CPU_AUTO)
            o.level = bench_level_of(argv[++i]);
        else if (value && strcmp(argv[i], "--stereo") == 0) o.stereo = argv[++i];
        else if (value && strcmp(argv[i], "--photos") == 0 && atoi(value) > 1) o.photos = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--max-size") == 0 && atoi(value) > 0) o.max_size = atoi(argv[++i]);
        else {
            fprintf(stderr, "usage: bench_splat [--json] [--quick] [--growth] [--filter TEXT] [--threads N]\n"
                            "                   [--scene COLMAP [--views FILE] [--start PLY] [--steps N] [--isa scalar|avx2|avx512]]\n"
                            "                   [--stereo COLMAP [--photos N] [--max-size PIXELS]]\n");
            return 2;
        }
    }
    if (o.scene) {
        bench_training(&o);
        return 0;
    }
    if (o.stereo) {
        bench_stereo(&o);
        return 0;
    }
    if (o.growth) {
        bench_growth(&o);
        return 0;
    }
    const gsf_cpu_level levels[] = {GSF_CPU_SCALAR, GSF_CPU_AVX2, GSF_CPU_AVX512};
    for (size_t k = 0; k < GSF__COUNT(levels); k++)
        for (int threads = 1; threads <= 2; threads++) bench_machine(&o, levels[k], threads);
    for (size_t k = 0; k < GSF__COUNT(levels); k++)
        for (int threads = 1; threads <= 2; threads++) {
            if (o.threads && threads != o.threads) continue;
            bench_render(&o, "10k 264x480", 10000, 0.03, 264, 480, levels[k], threads, 1);
            bench_stages(&o, "10k 264x480", 10000, 0.03, 264, 480, levels[k], threads);
            if (o.quick) continue;
            bench_stages(&o, "100k 960x540", 100000, 0.012, 960, 540, levels[k], threads);
            bench_stages(&o, "100k 1280x720", 100000, 0.012, 1280, 720, levels[k], threads);
            if (levels[k] > GSF_CPU_SCALAR)
                bench_stages(&o, "1M 1920x1080", 1000000, 0.005, 1920, 1080, levels[k], threads);
        }
    for (int threads = 1; threads <= 2; threads++) {
        if (o.threads && threads != o.threads) continue;
        bench_skips(&o, "10k 264x480", 10000, 0.03, 264, 480, threads);
        if (!o.quick) bench_skips(&o, "1M 1920x1080", 1000000, 0.005, 1920, 1080, threads);
        bench_lazy(&o, "10k 264x480", 10000, 0.03, 264, 480, 1.0, 0, o.quick ? 20 : 100, threads);
        for (int in_order = 1; in_order >= 0 && !o.quick; in_order--)
            bench_lazy(&o, "1M 960x540", 1000000, 0.005, 960, 540, 2.0, in_order, 10, threads);
        if (!o.quick) bench_lazy(&o, "1M 1920x1080", 1000000, 0.005, 1920, 1080, 2.0, 1, 10, threads);
    }
    bench_visibility(&o, "visibility 100k 20 views", 100000, 20, o.threads ? o.threads : 2);
    if (o.filter && !o.quick) bench_visibility(&o, "visibility 5M 100 views", 5000000, 100, o.threads ? o.threads : 2);
    return 0;
}
