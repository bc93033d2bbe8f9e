// Work whose results the platforms compare: with the scalar kernels, the same bits everywhere (tests/cross/same_bits.sh).
//   test_platforms                   trains, and compares the instruction sets of this machine with the scalar kernels
//   test_platforms digest            trains 300 steps with the scalar kernels, prints a checksum of what came out
//   test_platforms render|backward scalar|best N    renders N times, and goes back; for counting instructions and seconds
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"

#include "test.h"

enum { SPLATS = 160, VIEWS = 4, WIDTH = 56, HEIGHT = 40 };

typedef struct scene {
    gsf_splats truth, start;
    gsf_train_view views[VIEWS];
    float pixels[VIEWS][WIDTH * HEIGHT * 3];
} scene;

static gsf_camera make_camera(int view, int width, int height) { // around the origin, without functions of the C library
    static const double cosines[VIEWS] = {1.0, 0.8, 0.28, 0.96}, sines[VIEWS] = {0.0, 0.6, -0.96, -0.28};
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    const double c = cosines[view % VIEWS], s = sines[view % VIEWS];
    const double w2c[16] = {c, 0, s, 0, 0, 1, 0, 0, -s, 0, c, 0, 0, 0, 4, 1};
    memcpy(camera.w2c, w2c, sizeof w2c);
    camera.fx = camera.fy = 1.2 * width;
    camera.cx = 0.5 * width;
    camera.cy = 0.5 * height;
    camera.width = width;
    camera.height = height;
    return camera;
}

static void make_splats(gsf_context* ctx, gsf_splats* truth, gsf_splats* start, size_t count) {
    uint64_t state = 11;
    CHECK_OK(ctx, gsf_splat_make(ctx, count, 1, truth));
    CHECK_OK(ctx, gsf_splat_make(ctx, count, 1, start));
    for (size_t i = 0; i < count; i++) {
        for (size_t a = 0; a < 3; a++) {
            truth->means[3 * i + a] = (float)test_random_in(&state, -1, 1);
            truth->log_scales[3 * i + a] = (float)test_random_in(&state, -3.0, -1.4);
            truth->sh[12 * i + a] = (float)test_random_in(&state, -1.5, 1.5);
            for (size_t k = 1; k < 4; k++) truth->sh[12 * i + 3 * k + a] = (float)test_random_in(&state, -0.3, 0.3);
            start->means[3 * i + a] = truth->means[3 * i + a] + (float)test_random_in(&state, -0.06, 0.06);
            start->log_scales[3 * i + a] = truth->log_scales[3 * i + a] + (float)test_random_in(&state, -0.3, 0.3);
            start->sh[12 * i + a] = truth->sh[12 * i + a] * 0.5f;
        }
        for (size_t a = 0; a < 4; a++) truth->quats[4 * i + a] = start->quats[4 * i + a] = (float)test_random_in(&state, -1, 1);
        truth->opacity_logits[i] = (float)test_random_in(&state, 0, 3);
    }
}

static void make_scene(gsf_context* ctx, scene* s) {
    gsf_rasterizer* rasterizer = NULL;
    make_splats(ctx, &s->truth, &s->start, SPLATS);
    CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &rasterizer));
    for (int v = 0; v < VIEWS; v++) {
        gsf_render_output out;
        memset(&out, 0, sizeof out);
        memset(&s->views[v], 0, sizeof s->views[v]);
        s->views[v].camera = make_camera(v, WIDTH, HEIGHT);
        s->views[v].image = gsf_wrap_image(s->pixels[v], GSF_F32, WIDTH, HEIGHT, 3);
        out.color = s->views[v].image;
        CHECK_OK(ctx, gsf_splat_render(ctx, rasterizer, &s->truth, &s->views[v].camera, NULL, &out));
    }
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
}

static gsf_train_desc make_desc(int mcmc, int steps) { // densifies, resets and uses every regulariser
    gsf_train_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.iterations = steps;
    desc.seed = 42;
    desc.sh_interval = steps / 4;
    desc.densify_from = steps / 12;
    desc.densify_until = steps * 5 / 6;
    desc.densify_interval = steps / 6;
    desc.densify_grad = 5e-4f;
    desc.opacity_reset_interval = steps / 3;
    desc.prune_opacity = mcmc ? 0.1f : 0.006f;
    desc.dropout = 0.2f;
    desc.opacity_decay = 0.002f;
    desc.scale_penalty = 0.01f;
    desc.depth_smoothness = 0.01f;
    desc.background[1] = 0.2f;
    desc.coarse_until = steps / 5;
    desc.mcmc = mcmc;
    if (mcmc) desc.max_splats = SPLATS + 8;
    return desc;
}

static uint32_t train(gsf_context* ctx, const scene* s, int mcmc, int steps) { // checksum of the splats
    const gsf_train_desc desc = make_desc(mcmc, steps);
    gsf_trainer* trainer = NULL;
    uint32_t sum = 0;
    if (!CHECK_OK(ctx, gsf_splat_make_trainer(ctx, &desc, s->views, VIEWS, &s->start, &trainer))) return 0;
    for (int i = 0; i < steps; i++) CHECK_OK(ctx, gsf_splat_step_trainer(ctx, trainer, NULL));
    const gsf_splats* made = gsf_splat_get_trained(trainer);
    CHECK(made->count > SPLATS / 4 && made->count != SPLATS);
    sum = gsf__crc32(sum, made->means, 3 * made->count * sizeof(float));
    sum = gsf__crc32(sum, made->log_scales, 3 * made->count * sizeof(float));
    sum = gsf__crc32(sum, made->quats, 4 * made->count * sizeof(float));
    sum = gsf__crc32(sum, made->opacity_logits, made->count * sizeof(float));
    sum = gsf__crc32(sum, made->sh, 12 * made->count * sizeof(float));
    gsf_splat_destroy_trainer(ctx, trainer);
    return sum;
}

static uint32_t digest_maths(void) {
    uint64_t state = 5;
    uint32_t sum = 0;
    for (int i = 0; i < 20000; i++) {
        const double x = test_random_in(&state, -20.0, 20.0), y = test_random_in(&state, -1.0, 1.0);
        const double normal = gsf_draw_normal(1, 2, (uint64_t)i), e2 = (double)gsf__exp2_f32((float)x);
        const double results[] = {gsf__exp_f64(x), gsf__log_f64(fabs(x)), gsf__sin_f64(x), gsf__cos_f64(x), gsf__tan_f64(x),
                                  gsf__acos_f64(y), gsf__atan2_f64(y, x), gsf__cbrt_f64(x), gsf__expm1_f64(y),
                                  gsf__log1p_f64(y), gsf__power_f64(1.0 + y, 9), normal, e2, (double)gsf__exp_f32((float)x)};
        sum = gsf__crc32(sum, results, sizeof results);
    }
    return sum;
}

static void open_context(gsf_context* ctx, int best) {
    memset(ctx, 0, sizeof *ctx);
    ctx->threads = 1;
    ctx->cpu_level = best ? GSF_CPU_AUTO : GSF_CPU_SCALAR;
    CHECK_OK(ctx, gsf_init_context(ctx));
}

static int print_digest(int steps) {
    gsf_context ctx;
    static scene s;
    open_context(&ctx, 0);
    make_scene(&ctx, &s);
    uint32_t pixels = 0;
    for (int v = 0; v < VIEWS; v++) pixels = gsf__crc32(pixels, s.pixels[v], sizeof s.pixels[v]);
    const uint32_t maths = digest_maths(), trained = train(&ctx, &s, 0, steps), mcmc = train(&ctx, &s, 1, steps);
    printf("maths %08x pixels %08x trained %08x mcmc %08x\n", (unsigned)maths, (unsigned)pixels, (unsigned)trained,
           (unsigned)mcmc);
    gsf_splat_destroy(&ctx, &s.truth);
    gsf_splat_destroy(&ctx, &s.start);
    return test_failures != 0;
}

// A picture of `repeat` renders, and the gradients of its colours if `backward`.
static int run_work(int backward, int best, int repeat) {
    enum { WIDE = 160, HIGH = 120, MANY = 3000 };
    static float pixels[WIDE * HIGH * 3], slopes[WIDE * HIGH * 3];
    gsf_context ctx;
    gsf_splats truth, start;
    gsf_splat_grads grads;
    gsf_rasterizer* rasterizer = NULL;
    gsf_render_output out;
    open_context(&ctx, best);
    make_splats(&ctx, &truth, &start, MANY);
    const gsf_camera camera = make_camera(0, WIDE, HIGH);
    memset(&out, 0, sizeof out);
    memset(&grads, 0, sizeof grads);
    out.color = gsf_wrap_image(pixels, GSF_F32, WIDE, HIGH, 3);
    float* memory = (float*)calloc(MANY * 23, sizeof(float));
    grads.means = memory;
    grads.log_scales = grads.means + 3 * MANY;
    grads.quats = grads.log_scales + 3 * MANY;
    grads.opacity_logits = grads.quats + 4 * MANY;
    grads.sh = grads.opacity_logits + MANY;
    for (int i = 0; i < WIDE * HIGH * 3; i++) slopes[i] = (float)(i % 7 - 3);
    CHECK_OK(&ctx, gsf_splat_make_rasterizer(&ctx, &rasterizer));
    const double begin = gsf__seconds();
    for (int i = 0; i < repeat; i++) {
        CHECK_OK(&ctx, gsf_splat_render(&ctx, rasterizer, &truth, &camera, NULL, &out));
        if (!backward) continue;
        CHECK_OK(&ctx, gsf_splat_render_backward(&ctx, rasterizer, &truth, &camera, NULL, slopes, NULL, NULL, &grads));
    }
    printf("%s %s %d %.4f s\n", backward ? "backward" : "render", gsf_describe_cpu_level(ctx.cpu_level), repeat,
           gsf__seconds() - begin);
    gsf_splat_destroy_rasterizer(&ctx, rasterizer);
    gsf_splat_destroy(&ctx, &truth);
    gsf_splat_destroy(&ctx, &start);
    free(memory);
    return test_failures != 0;
}

int main(int argc, char** argv) {
    if (argc == 2 && strcmp(argv[1], "digest") == 0) return print_digest(300);
    if (argc == 4) return run_work(argv[1][0] == 'b', argv[2][0] == 'b', atoi(argv[3]));
    CHECK(print_digest(60) == 0);
    CHECK(run_work(1, 1, 1) == 0);
    return test_report();
}
