// bench_splat.c - seconds beside error of the splat path.
// By hand: cc -O2 -fopenmp -I. bench/bench_splat.c -o bench_splat -lm
//
//     bench_splat [--json] [--quick] [--filter TEXT] [--threads N] [--scene COLMAP [--views FILE] [--start PLY] [--steps N]]
//
// Without a scene: render and backward of made-up splats at several sizes, for each instruction set of the machine, each
// against the double-precision reference of tests/reference_splat.h (error columns) where that is affordable.
// With a scene: whole training steps (render, loss, backward, Adam; density control off) on its photos. --views names a
// text file of image names, one per line; --start a PLY to begin with instead of the scene's points. The first 5 steps
// warm up; the median, and the process' CPU seconds per step, are over the rest.
#define GSFIXER_IMPLEMENTATION
#define GSF_ASSERT(x) ((void)0)
#include "../gsfixer_splat.h"
#include "../tests/reference_splat.h"

#include <time.h>

typedef struct bench_options {
    int json, quick, threads, steps;
    const char *filter, *scene, *views, *start;
} bench_options;

typedef struct bench_row {
    const char *name, *variant, *isa, *work_unit, *reference;
    int threads;
    double seconds, cpu_seconds, work, error_max, error_rel_l2; // errors < 0: not measured
} bench_row;

static double bench_now(void) {
    struct timespec t;
    timespec_get(&t, TIME_UTC);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double bench_cpu(void) { return (double)clock() / CLOCKS_PER_SEC; }

static int bench_compare(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return (x > y) - (x < y);
}

static double bench_median(double* values, size_t count) {
    qsort(values, count, sizeof *values, bench_compare);
    return count ? values[count / 2] : 0.0;
}

static void bench_print(const bench_options* o, const bench_row* row) {
    const double rate = row->seconds > 0.0 ? row->work / row->seconds : 0.0;
    if (o->json) {
        printf("{\"bench\":\"splat\",\"case\":\"%s\",\"variant\":\"%s\",\"isa\":\"%s\",\"threads\":%d,\"seconds\":%.6g,"
               "\"cpu_seconds\":%.6g,\"work\":%.6g,\"work_unit\":\"%s\",\"rate\":%.6g,\"reference\":\"%s\"",
               row->name, row->variant, row->isa, row->threads, row->seconds, row->cpu_seconds, row->work, row->work_unit,
               rate, row->reference);
        if (row->error_max >= 0.0) printf(",\"error_max\":%.3g,\"error_rel_l2\":%.3g", row->error_max, row->error_rel_l2);
        printf("}\n");
    } else {
        printf("%-26s %-9s %-6s %d thr %9.3f ms %9.3f ms cpu %9.4g %s/s", row->name, row->variant, row->isa, row->threads,
               1e3 * row->seconds, 1e3 * row->cpu_seconds, rate, row->work_unit);
        if (row->error_max >= 0.0) printf("  max %.2g  rel L2 %.2g", row->error_max, row->error_rel_l2);
        printf("\n");
    }
    fflush(stdout);
}

static void bench_require(gsf_context* ctx, gsf_result result) {
    if (result == GSF_OK) return;
    fprintf(stderr, "bench_splat: %s (%s)\n", ctx->error, gsf_describe_result(result));
    exit(1);
}

// A cloud that covers the image about evenly: anisotropic, half transparent, SH degree 3.
static void bench_make_splats(gsf_context* ctx, size_t count, double size, gsf_splats* s) {
    bench_require(ctx, gsf_splat_make(ctx, count, 3, s));
    for (size_t i = 0; i < count; i++) {
        for (uint64_t k = 0; k < 3; k++) {
            s->means[3 * i + k] = (float)((gsf_random_uniform(1, k, i) * 2.0 - 1.0) * (k == 2 ? 1.0 : 2.0));
            s->log_scales[3 * i + k] = (float)(log(size) + 0.5 * gsf_random_normal(2, k, i));
        }
        for (uint64_t k = 0; k < 4; k++) s->quats[4 * i + k] = (float)gsf_random_normal(3, k, i);
        s->opacity_logits[i] = (float)gsf_random_normal(4, 0, i);
        for (uint64_t k = 0; k < 48; k++) s->sh[48 * i + k] = (float)(0.2 * gsf_random_normal(5, k, i));
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

static void bench_error(const float* actual, const double* expected, const double* margin, size_t count, size_t per_pixel,
                        bench_row* row) {
    double worst = 0.0, difference = 0.0, total = 0.0;
    for (size_t i = 0; i < count; i++) {
        if (margin && margin[i / per_pixel] < 1e-4) continue; // a yes/no decision of this pixel is within rounding
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
    if (o->filter && !strstr(forward_name, o->filter) && !strstr(backward_name, o->filter)) return;
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.cpu_level = level;
    ctx.threads = threads;
    bench_require(&ctx, gsf_init_context(&ctx));
    if (ctx.cpu_level != level) return;

    gsf_splats splats, sums;
    bench_make_splats(&ctx, count, size, &splats);
    bench_require(&ctx, gsf_splat_make(&ctx, count, 3, &sums));
    const gsf_camera camera = bench_camera(width, height);
    const size_t values = 3 * (size_t)width * (size_t)height;
    float* d_color = (float*)gsf_alloc(&ctx, values, sizeof(float));
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    bench_require(&ctx, gsf_make_image(&ctx, GSF_F32, width, height, 3, &out.color));
    if (!d_color) exit(1);
    for (size_t i = 0; i < values; i++) d_color[i] = (float)gsf_random_normal(6, 0, i);
    gsf_splat_grads grads;
    memset(&grads, 0, sizeof grads);
    grads.means = sums.means;
    grads.log_scales = sums.log_scales;
    grads.quats = sums.quats;
    grads.opacity_logits = sums.opacity_logits;
    grads.sh = sums.sh;
    gsf_rasterizer* rasterizer;
    bench_require(&ctx, gsf_splat_make_rasterizer(&ctx, &rasterizer));

    enum { MOST = 15 };
    double forward[MOST], backward[MOST], cpu[2] = {0.0, 0.0};
    const int rounds = o->quick ? 5 : MOST;
    for (int i = -1; i < rounds; i++) { // one round of warming up
        memset(sums.owned, 0, splats.count * (3 + 3 + 4 + 1 + 48) * sizeof(float));
        const double t0 = bench_now(), c0 = bench_cpu();
        bench_require(&ctx, gsf_splat_render(&ctx, rasterizer, &splats, &camera, NULL, &out));
        const double t1 = bench_now(), c1 = bench_cpu();
        bench_require(&ctx,
                      gsf_splat_render_backward(&ctx, rasterizer, &splats, &camera, NULL, d_color, NULL, NULL, &grads));
        if (i < 0) continue;
        forward[i] = t1 - t0;
        backward[i] = bench_now() - t1;
        cpu[0] += (c1 - c0) / rounds;
        cpu[1] += (bench_cpu() - c1) / rounds;
    }
    bench_row rows[2];
    memset(rows, 0, sizeof rows);
    for (int k = 0; k < 2; k++) {
        rows[k].name = k ? backward_name : forward_name;
        rows[k].variant = "default";
        rows[k].isa = gsf_cpu_level_name(level);
        rows[k].threads = threads;
        rows[k].seconds = bench_median(k ? backward : forward, (size_t)rounds);
        rows[k].cpu_seconds = cpu[k];
        rows[k].work = (double)width * height;
        rows[k].work_unit = "pixels";
        rows[k].reference = "none";
        rows[k].error_max = rows[k].error_rel_l2 = -1.0;
    }
    if (with_reference) {
        ref_splats exact = ref_splats_from(&splats);
        ref_options options = ref_options_from(NULL);
        ref_image image = ref_render(&exact, &camera, &options);
        double* d_wide = (double*)malloc(values * sizeof(double));
        if (!d_wide) exit(1);
        double blended = 0.0;
        for (size_t i = 0; i < values; i++) d_wide[i] = (double)d_color[i];
        for (size_t i = 0; i < values / 3; i++) blended += image.blended[i];
        ref_grads expected = ref_make_grads(exact.count, exact.sh_count);
        ref_render_backward(&exact, &camera, &options, &image, d_wide, NULL, NULL, &expected);
        bench_error((const float*)out.color.data, image.color, image.margin, values, 3, &rows[0]);
        bench_error(sums.means, expected.means, NULL, 3 * count, 1, &rows[1]);
        for (int k = 0; k < 2; k++) {
            rows[k].work = blended;
            rows[k].work_unit = "pairs";
            rows[k].reference = "float64";
        }
        free(d_wide);
        ref_destroy_grads(&expected);
        ref_destroy_image(&image);
        ref_destroy_splats(&exact);
    }
    for (int k = 0; k < 2; k++)
        if (!o->filter || strstr(rows[k].name, o->filter)) bench_print(o, &rows[k]);
    gsf_splat_destroy_rasterizer(&ctx, rasterizer);
    gsf_destroy_image(&ctx, &out.color);
    gsf_free(&ctx, d_color);
    gsf_splat_destroy(&ctx, &sums);
    gsf_splat_destroy(&ctx, &splats);
}

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
    if (o->start) bench_require(&ctx, gsf_splat_load_ply(&ctx, o->start, &start));
    else
        bench_require(&ctx, gsf_splat_from_points(&ctx, scene.points, scene.colors, scene.point_count, NULL, 3,
                                                  scene.origin, &start));
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = 30000;
    desc.sh_interval = 1; // all bands from the first step
    desc.densify_until = -1;
    desc.opacity_reset_interval = 1 << 30;
    gsf_trainer* trainer;
    bench_require(&ctx, gsf_splat_make_trainer(&ctx, &desc, views, count, &start, &trainer));

    double* seconds = (double*)gsf_alloc(&ctx, (size_t)o->steps, sizeof(double));
    if (!seconds) exit(1);
    gsf_train_stats stats;
    for (int i = 0; i < 5; i++) bench_require(&ctx, gsf_splat_train_step(&ctx, trainer, &stats));
    const double cpu = bench_cpu();
    for (int i = 0; i < o->steps; i++) {
        const double t = bench_now();
        bench_require(&ctx, gsf_splat_train_step(&ctx, trainer, &stats));
        seconds[i] = bench_now() - t;
    }
    bench_row row;
    memset(&row, 0, sizeof row);
    row.name = "train step";
    row.variant = "default";
    row.isa = gsf_cpu_level_name(ctx.cpu_level);
    row.threads = ctx.parallel.worker_count;
    row.cpu_seconds = (bench_cpu() - cpu) / o->steps;
    row.seconds = bench_median(seconds, (size_t)o->steps);
    row.work = (double)start.count;
    row.work_unit = "splats";
    row.reference = "none";
    row.error_max = -1.0;
    bench_print(o, &row);
    gsf_free(&ctx, seconds);
    gsf_splat_destroy_trainer(&ctx, trainer);
    gsf_splat_destroy(&ctx, &start);
    gsf_free(&ctx, views);
    gsf_free(&ctx, list);
    gsf_splat_destroy_scene(&ctx, &scene);
}

int main(int argc, char** argv) {
    bench_options o;
    memset(&o, 0, sizeof o);
    o.steps = 200;
    for (int i = 1; i < argc; i++) {
        const char* value = i + 1 < argc ? argv[i + 1] : NULL;
        if (strcmp(argv[i], "--json") == 0) o.json = 1;
        else if (strcmp(argv[i], "--quick") == 0) o.quick = 1;
        else if (value && strcmp(argv[i], "--filter") == 0) o.filter = argv[++i];
        else if (value && strcmp(argv[i], "--threads") == 0) o.threads = atoi(argv[++i]);
        else if (value && strcmp(argv[i], "--scene") == 0) o.scene = argv[++i];
        else if (value && strcmp(argv[i], "--views") == 0) o.views = argv[++i];
        else if (value && strcmp(argv[i], "--start") == 0) o.start = argv[++i];
        else if (value && strcmp(argv[i], "--steps") == 0 && atoi(value) > 0) o.steps = atoi(argv[++i]);
        else {
            fprintf(stderr, "usage: bench_splat [--json] [--quick] [--filter TEXT] [--threads N]\n"
                            "                   [--scene COLMAP [--views FILE] [--start PLY] [--steps N]]\n");
            return 2;
        }
    }
    if (o.scene) {
        bench_training(&o);
        return 0;
    }
    const gsf_cpu_level levels[] = {GSF_CPU_SCALAR, GSF_CPU_AVX2};
    for (size_t k = 0; k < GSF__COUNT(levels); k++)
        for (int threads = 1; threads <= 2; threads++) {
            if (o.threads && threads != o.threads) continue;
            bench_render(&o, "10k 264x480", 10000, 0.03, 264, 480, levels[k], threads, 1);
            if (o.quick) continue;
            bench_render(&o, "100k 960x540", 100000, 0.012, 960, 540, levels[k], threads, 0);
            if (levels[k] > GSF_CPU_SCALAR)
                bench_render(&o, "1M 1920x1080", 1000000, 0.005, 1920, 1080, levels[k], threads, 0);
        }
    return 0;
}
