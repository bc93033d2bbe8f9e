// render_only.c - the renderer in a unit of its own: all functions private and only gsf_splat_render used, so that each
// function has one caller and everything is inlined. Optimisers treat such a unit differently. Compared with the
// double-precision reference at every CPU level; prints a hash of each level's images. Built by render_only.sh.
#define GSFIXER_STATIC
#define GSFIXER_SPLAT_IMPLEMENTATION
#define GSFIXER_BASE_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"
#include "reference_splat.h"
#include "splat_golden.h"

typedef struct renderer { gsf_context ctx; gsf_rasterizer* rasterizer; uint64_t hash; } renderer;

// Pixels at the threshold of a decision (1/255, 0.99, 1e-4, depth order) may differ.
static void check_render(renderer* r, const char* scene, const gsf_splats* splats, const gsf_camera* camera,
                         const gsf_render_desc* desc, double tolerance) {
    const size_t pixels = (size_t)camera->width * (size_t)camera->height;
    ref_splats s = ref_splats_from(splats);
    const ref_options options = ref_options_from(desc);
    ref_image expected = ref_render(&s, camera, &options);
    float* actual = (float*)calloc(3 * pixels, sizeof(float));
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(actual, GSF_F32, camera->width, camera->height, 3);
    CHECK_OK(&r->ctx, gsf_splat_render(&r->ctx, r->rasterizer, splats, camera, desc, &out));
    double worst = 0;
    size_t compared = 0, drawn = 0;
    for (size_t i = 0; i < pixels; i++) {
        uint32_t bits[3];
        memcpy(bits, actual + 3 * i, sizeof bits);
        for (int c = 0; c < 3; c++) r->hash = (r->hash ^ bits[c]) * 0x100000001b3u;
        if (expected.margin[i] < 1e-4 || expected.depth_gap[i] < 1e-6) continue;
        compared++;
        drawn += expected.T[i] < 0.9;
        for (size_t c = 0; c < 3; c++) {
            const double error = fabs((double)actual[3 * i + c] - expected.color[3 * i + c]);
            if (!(error <= worst)) worst = error; // NaN wins
        }
    }
    CHECK(compared > pixels / 2 && drawn > pixels / 20);
    if (!CHECK(worst <= tolerance))
        fprintf(stderr, "%s, %s: off by %.3g, allowed %.3g\n", scene, gsf_describe_cpu_level(r->ctx.cpu_level), worst,
                tolerance);
    if (getenv("GSF_TEST_VERBOSE"))
        printf("%s %s: %.3g\n", gsf_describe_cpu_level(r->ctx.cpu_level), scene, worst);
    free(actual);
    ref_destroy_image(&expected);
    ref_destroy_splats(&s);
}

static void check_golden(renderer* r, const char* name) {
    splat_golden g = splat_golden_open(name);
    gsf_render_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.sh_bands = g.sh_bands;
    for (int c = 0; c < 3; c++) desc.background[c] = (float)g.background[c];
    check_render(r, name, &g.splats, &g.camera, &desc, 5e-6);
    splat_golden_close(&g);
}

// An image 20,000 pixels wide of splats about a pixel wide, seen from far away: positions on the screen and of the camera
// need more digits than a float has.
static void check_wide(renderer* r) {
    enum { COUNT = 3000, WIDTH = 20000, HEIGHT = 8 };
    const double distance = 3e4, focal = 1e6;
    gsf_splats splats;
    CHECK_OK(&r->ctx, gsf_splat_make(&r->ctx, COUNT, 3, &splats));
    uint64_t state = 17;
    for (size_t i = 0; i < COUNT; i++) {
        splats.means[3 * i] = (float)(test_random_in(&state, -0.5, 0.5) * WIDTH * distance / focal);
        splats.means[3 * i + 1] = (float)(test_random_in(&state, -0.5, 0.5) * HEIGHT * distance / focal);
        splats.means[3 * i + 2] = (float)test_random_in(&state, -100, 100);
        for (int k = 0; k < 3; k++) splats.log_scales[3 * i + (size_t)k] = (float)test_random_in(&state, -6, -2.5);
        for (int k = 0; k < 4; k++) splats.quats[4 * i + (size_t)k] = (float)test_random_in(&state, -1, 1);
        splats.opacity_logits[i] = (float)test_random_in(&state, -1, 3);
        for (int k = 0; k < 48; k++) splats.sh[48 * i + (size_t)k] = (float)test_random_in(&state, -0.6, 0.6);
    }
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.w2c[0] = camera.w2c[5] = camera.w2c[10] = camera.w2c[15] = 1;
    camera.w2c[14] = distance + 0.1;
    camera.width = WIDTH;
    camera.height = HEIGHT;
    camera.fx = camera.fy = focal;
    camera.cx = WIDTH / 2.0 + 0.1;
    camera.cy = HEIGHT / 2.0 + 0.3;
    gsf_render_desc desc;
    memset(&desc, 0, sizeof desc);
    check_render(r, "wide", &splats, &camera, &desc, 5e-6);
    gsf_splat_destroy(&r->ctx, &splats);
}

int main(void) {
    static const gsf_cpu_level levels[] = {GSF_CPU_SCALAR, GSF_CPU_AVX2};
    const test_names scenes = splat_golden_scenes();
    for (size_t k = 0; k < sizeof levels / sizeof levels[0]; k++) {
        renderer r;
        memset(&r, 0, sizeof r);
        r.hash = 0xcbf29ce484222325u;
        r.ctx.cpu_level = levels[k];
        if (!CHECK_OK(&r.ctx, gsf_init_context(&r.ctx))) break;
        if (r.ctx.cpu_level != levels[k]) continue; // not on this machine
        if (!CHECK_OK(&r.ctx, gsf_splat_make_rasterizer(&r.ctx, &r.rasterizer))) break;
        for (size_t s = 0; s < scenes.count; s++) check_golden(&r, scenes.name[s]);
        check_wide(&r);
        gsf_splat_destroy_rasterizer(&r.ctx, r.rasterizer);
        printf("%s %016llx\n", gsf_describe_cpu_level(r.ctx.cpu_level), (unsigned long long)r.hash);
    }
    return test_report();
}
