// The frame loop of README's tutorial: photos as linear EXR files, cameras from glm, a job system of three threads. The
// decoded photos match the originals, training reduces the loss, and one thread renders the same bits.
#define GSF_USE_OIIO
#define GSF_USE_GLM
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"

#include <atomic>
#include <cmath>
#include <functional>
#include <glm/gtc/matrix_transform.hpp>
#include <thread>

struct job_system {
    int workers;
    int32_t worker_count() const { return workers; }
    void parallel_for(size_t count, const std::function<void(size_t, int)>& body) {
        std::atomic<size_t> next(0);
        const auto work = [&](int32_t worker) {
            for (size_t i = next++; i < count; i = next++) body(i, worker);
        };
        std::vector<std::thread> threads;
        for (int32_t worker = 1; worker < workers; worker++) threads.emplace_back(work, worker);
        work(0);
        for (std::thread& thread : threads) thread.join();
    }
};

#include "readme_engine.h"

enum { W = 32, H = 24, PHOTOS = 3, SPLATS = 60 };

static double linear_of(double x) { return x <= 0.04045 ? x / 12.92 : std::pow((x + 0.055) / 1.055, 2.4); }

static glm::dmat4 view_of(int i) {
    return glm::lookAt(glm::dvec3(0.6 * (i - 1), 0.2, 4.0), glm::dvec3(0.0), glm::dvec3(0.0, 1.0, 0.0));
}

static glm::dmat4 projection() { return glm::perspective(0.7, (double)W / H, 0.1, 100.0); }

static void make_splats(gsf_context* ctx, uint64_t seed, gsf_splats* out) {
    CHECK_OK(ctx, gsf_splat_make(ctx, SPLATS, 0, out));
    for (size_t i = 0; i < SPLATS; i++) {
        for (uint64_t a = 0; a < 3; a++) {
            out->means[3 * i + a] = (float)(2.0 * gsf_draw_uniform(seed, a, i) - 1.0);
            out->log_scales[3 * i + a] = -2.0f;
            out->sh[3 * i + a] = (float)gsf_draw_normal(seed, 3 + a, i);
        }
        out->quats[4 * i] = 1.0f;
        out->opacity_logits[i] = 1.0f;
    }
}

// A render as the scene's photo: written linear, and compared with what add_photo reads.
static void take_photo(gsf_context* ctx, const gsf_splats* splats, int i, std::vector<gsf_train_view>* views) {
    static float coded[W * H * 3], linear[W * H * 3];
    gsf_camera camera = {};
    gsf_from_glm_projection(projection(), W, H, &camera);
    gsf_from_glm_view(view_of(i), &camera);
    gsf_rasterizer* rasterizer = NULL;
    gsf_render_output out = {};
    out.color = gsf_wrap_image(coded, GSF_F32, W, H, 3);
    CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &rasterizer));
    CHECK_OK(ctx, gsf_splat_render(ctx, rasterizer, splats, &camera, NULL, &out));
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    for (int k = 0; k < W * H * 3; k++) {
        coded[k] = coded[k] < 1.0f ? coded[k] : 1.0f;
        linear[k] = (float)linear_of(coded[k]);
    }
    gsf_image file = gsf_wrap_image(linear, GSF_F32, W, H, 3);
    file.color_space = GSF_COLOR_LINEAR;
    char name[16];
    snprintf(name, sizeof name, "photo%d.exr", i);
    CHECK_OK(ctx, gsf_save_image(ctx, test_scratch(name), &file));
    if (!CHECK_OK(ctx, add_photo(ctx, test_scratch(name), view_of(i), projection(), views))) return;
    CHECK(memcmp(&views->back().camera, &camera, sizeof camera) == 0);
    CHECK(views->back().image.color_space == GSF_COLOR_SRGB);
    for (int k = 0; k < W * H * 3; k++) CHECK_NEAR(((const float*)views->back().image.data)[k], coded[k], 1e-5);
}

static void run(int workers, float* pixels) {
    job_system jobs = {workers};
    repair_task task;
    CHECK_OK(&task.ctx, task.begin(&jobs));
    gsf_splats truth, start;
    make_splats(&task.ctx, 1, &truth);
    make_splats(&task.ctx, 2, &start);
    std::vector<gsf_train_view> views;
    for (int i = 0; i < PHOTOS; i++) take_photo(&task.ctx, &truth, i, &views);
    if (CHECK_OK(&task.ctx, task.start(views, start))) {
        const gsf_image color = gsf_wrap_image(pixels, GSF_F32, W, H, 3);
        double first = 0.0, last = 0.0;
        int frames = 0, steps = 0;
        while (task.stats.stage != GSF_FIX_DONE && frames < 2000) { // a budget of zero: one step per frame
            if (!CHECK_OK(&task.ctx, task.frame(0.0, view_of(1), projection(), color))) break;
            frames++;
            if (task.stats.stage != GSF_FIX_TRAIN) continue;
            last = task.stats.train.loss;
            if (++steps == 1) first = last;
        }
        CHECK(task.stats.stage == GSF_FIX_DONE);
        CHECK(steps == 1200);
        CHECK(frames > steps + 1); // rounds of repair lie between the iterations
        CHECK(last < 0.5 * first);
    }
    task.end();
    for (gsf_train_view& view : views) gsf_destroy_image(&task.ctx, &view.image);
    gsf_splat_destroy(&task.ctx, &truth);
    gsf_splat_destroy(&task.ctx, &start);
}

int main() {
    static float pixels[2][W * H * 3];
    run(3, pixels[0]);
    run(1, pixels[1]);
    CHECK(memcmp(pixels[0], pixels[1], sizeof pixels[0]) == 0);
    return test_report();
}
