// engine.cpp - g++ -O2 -std=c++20 -I. examples/engine.cpp -o engine -lOpenImageIO -lOpenImageIO_Util -lpthread
// Repairs splats in an engine's frame loop: linear EXR photos, glm cameras in OpenGL's convention, the engine's jobs, some
// milliseconds per frame, a splat file that is loaded anew when it changes.     engine FOLDER [MILLISECONDS [WORKERS]]
// FOLDER: photo0.exr ... of the cameras of view_at, start.ply; every 100 frames it writes splats.ply. Ctrl-C stops, and saves.
#define GSF_USE_OIIO
#define GSF_USE_GLM
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include <atomic>
#include <barrier>
#include <chrono>
#include <csignal>
#include <filesystem>
#include <functional>
#include <glm/gtc/matrix_transform.hpp>
#include <thread>
#include <vector>
using clock_type = std::chrono::steady_clock;
class job_system { // threads that wait at a gate for the next loop; the caller is worker 0
    std::barrier<> gate;
    std::function<void(size_t, int)> body;
    std::atomic<size_t> next{0};
    size_t count = 0;
    std::vector<std::jthread> threads;
    void work(int worker) { for (size_t i = next++; i < count; i = next++) body(i, worker); }
public:
    explicit job_system(int workers) : gate(workers) {
        for (int worker = 1; worker < workers; worker++)
            threads.emplace_back([this, worker] {
                for (gate.arrive_and_wait(); body; gate.arrive_and_wait()) work(worker), gate.arrive_and_wait();
            });
    }
    ~job_system() { body = nullptr, gate.arrive_and_wait(); } // without a body, the threads end
    int worker_count() const { return (int)threads.size() + 1; }
    void parallel_for(size_t n, const std::function<void(size_t, int)>& f) {
        body = f, count = n, next = 0, gate.arrive_and_wait(); // opens the gate
        work(0), gate.arrive_and_wait();
    }
};

// `view` and `projection` as glm::lookAt and glm::perspective return them. The caller destroys views->image.
static gsf_result add_photo(gsf_context* ctx, const char* exr, const glm::dmat4& view, const glm::dmat4& projection,
                            std::vector<gsf_train_view>* views) {
    gsf_train_view v = {};
    const gsf_result r = gsf_load_image(ctx, exr, 3, &v.image); // linear colors, which the trainer encodes as sRGB;
    if (r) return r;                                            // tone mapping, if any, goes before
    gsf_from_glm_projection(projection, (int32_t)v.image.width, (int32_t)v.image.height, &v.camera);
    gsf_from_glm_view(view, &v.camera);
    views->push_back(v);
    return GSF_OK;
}

// Loads a splat file of any format if it has changed. Files are replaced as a whole, so that none is read half-written.
static gsf_result reload(gsf_context* ctx, const std::string& path, std::filesystem::file_time_type* seen, gsf_splats* splats) {
    std::error_code missing;
    const auto time = std::filesystem::last_write_time(path, missing);
    if (missing || time == std::exchange(*seen, time)) return GSF_OK;
    gsf_splats fresh = {};
    const gsf_result r = gsf_splat_load(ctx, path.c_str(), &fresh);
    if (r) return r;
    std::swap(*splats, fresh), gsf_splat_destroy(ctx, &fresh);
    printf("loaded %s: %zu splats\n", path.c_str(), splats->count);
    return GSF_OK;
}

static gsf_context engine;
static glm::dmat4 view_at(double t) { return glm::lookAt(glm::dvec3(t * 0.6 - 0.6, 0.2, 4), {}, glm::dvec3(0, 1, 0)); }

int main(int argc, char** argv) {
    if (argc < 2) return fprintf(stderr, "usage: engine FOLDER [MILLISECONDS [WORKERS]]\n"), 2;
    const std::string folder = argv[1], saved = folder + "/splats.ply";
    const double budget = argc > 2 ? atof(argv[2]) : 8.0;
    const glm::dmat4 projection = glm::perspective(0.7, 4.0 / 3.0, 0.1, 100.0);
    job_system jobs(argc > 3 ? std::max(atoi(argv[3]), 1) : (int)std::thread::hardware_concurrency());
    engine.parallel.for_fn = [](void* user, size_t count, gsf_chunk_fn body, void* arg) {
        static_cast<job_system*>(user)->parallel_for(count, [=](size_t i, int worker) { body(arg, i, worker); });
    };
    engine.parallel.user = &jobs;
    engine.parallel.worker_count = jobs.worker_count();
    gsf_result r = gsf_init_context(&engine);
    signal(SIGINT, [](int) { gsf_request_cancel(&engine); });
    std::vector<gsf_train_view> views;
    for (std::string path; !r && std::filesystem::exists(path = folder + "/photo" + std::to_string(views.size()) + ".exr");)
        r = add_photo(&engine, path.c_str(), view_at((double)views.size()), projection, &views);
    gsf_splats splats = {};
    gsf_restorer warp = {};
    gsf_fixer* fixer = nullptr;
    gsf_fix_stats stats = {};
    gsf_image screen = {};
    gsf_camera camera = {};
    std::filesystem::file_time_type seen = {};
    if (!r && views.empty()) r = gsf_fail(&engine, GSF_ERROR_NOT_FOUND, "%s: no photo0.exr", folder.c_str());
    gsf_fix_desc desc = gsf_splat_resolve_few_view_desc(NULL, views.size(), GSF_QUALITY_FAST);
    if (!r) desc.train.render.near_plane = gsf_splat_measure_near_plane(&views[0].camera, sizeof views[0], views.size());
    if (!r) r = gsf_splat_load(&engine, (folder + "/start.ply").c_str(), &splats);
    if (!r) r = gsf_splat_make_warp(&engine, &warp);
    if (!r) r = gsf_splat_make_fixer(&engine, &desc, views.data(), views.size(), &splats, &warp, &fixer); // copies both
    if (!r) r = gsf_make_image(&engine, GSF_F32, 160, 120, 3, &screen);
    gsf_from_glm_projection(projection, 160, 120, &camera);
    gsf_trainer* trainer = fixer ? gsf_splat_get_trainer(fixer) : nullptr;
    for (int frame = 1; !r && stats.stage != GSF_FIX_DONE; frame++) {
        const clock_type::time_point end = clock_type::now() + std::chrono::microseconds((int64_t)(1000.0 * budget));
        do r = gsf_splat_step_fixer(&engine, fixer, &stats); // one training iteration, or the repair of one window of frames
        while (!r && stats.stage != GSF_FIX_DONE && clock_type::now() < end);
        gsf_from_glm_view(view_at(1.0 + sin(0.01 * frame)), &camera);
        const gsf_render_output out = {screen, {}, {}}; // an engine displays it
        if (!r) r = gsf_splat_render_trainer(&engine, trainer, &camera, &out);
        if (!r && frame % 100 == 0) r = gsf_splat_save(&engine, saved.c_str(), gsf_splat_get_trained(trainer), NULL);
        if (!r && reload(&engine, saved, &seen, &splats)) puts(engine.error); // what it had stays
    }
    if (r == GSF_ERROR_CANCELLED) printf("cancelled\n"), gsf_clear_cancel(&engine), r = GSF_OK; // the step changed nothing
    if (!r && trainer) r = gsf_splat_save(&engine, saved.c_str(), gsf_splat_get_trained(trainer), NULL);
    if (r) fprintf(stderr, "%s\n", engine.error);
    for (gsf_train_view& view : views) gsf_destroy_image(&engine, &view.image);
    gsf_destroy_image(&engine, &screen);
    gsf_splat_destroy_fixer(&engine, fixer);
    gsf_destroy_restorer(&engine, &warp);
    gsf_splat_destroy(&engine, &splats);
    return r ? 1 : 0;
}
