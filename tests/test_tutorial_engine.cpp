// The engine of examples/engine.cpp, run as a program: photos are linear EXR files and match the originals when they are read,
// the splats that it saves show the photos better than those it began with, they are reloaded while it runs, one worker gives
// the same bytes as three, and a cancelled run saves what it has.
#define GSFIXER_IMPLEMENTATION
#define main engine_main
#include "../examples/engine.cpp"
#undef main
#include "test.h"

enum { W = 32, H = 24, PHOTOS = 3, SPLATS = 60 };

static double linear_of(double x) { return x <= 0.04045 ? x / 12.92 : std::pow((x + 0.055) / 1.055, 2.4); }

static void make_splats(gsf_context* c, uint64_t seed, gsf_splats* out) {
    CHECK_OK(c, gsf_splat_make(c, SPLATS, 0, out));
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

static void render(gsf_context* c, const gsf_splats* splats, int i, float* pixels) {
    gsf_camera camera = {};
    gsf_from_glm_projection(glm::perspective(0.7, 4.0 / 3.0, 0.1, 100.0), W, H, &camera);
    gsf_from_glm_view(view_at(i), &camera);
    gsf_rasterizer* rasterizer = NULL;
    gsf_render_output out = {};
    out.color = gsf_wrap_image(pixels, GSF_F32, W, H, 3);
    CHECK_OK(c, gsf_splat_make_rasterizer(c, &rasterizer));
    CHECK_OK(c, gsf_splat_render(c, rasterizer, splats, &camera, NULL, &out));
    gsf_splat_destroy_rasterizer(c, rasterizer);
    for (int k = 0; k < W * H * 3; k++) pixels[k] = pixels[k] < 1.0f ? pixels[k] : 1.0f;
}

// A render as the scene's photo, written linear, and what add_photo and a trainer make of it.
static void take_photo(gsf_context* c, const gsf_splats* splats, int i) {
    static float coded[W * H * 3], linear[W * H * 3], back[W * H * 3];
    render(c, splats, i, coded);
    for (int k = 0; k < W * H * 3; k++) linear[k] = (float)linear_of(coded[k]);
    gsf_image file = gsf_wrap_image(linear, GSF_F32, W, H, 3);
    file.color_space = GSF_COLOR_LINEAR;
    char name[16];
    snprintf(name, sizeof name, "photo%d.exr", i);
    CHECK_OK(c, gsf_save_image(c, test_scratch(name), &file));
    std::vector<gsf_train_view> views;
    const glm::dmat4 projection = glm::perspective(0.7, 4.0 / 3.0, 0.1, 100.0);
    if (!CHECK_OK(c, add_photo(c, test_scratch(name), view_at(i), projection, &views))) return;
    CHECK(views[0].image.color_space == GSF_COLOR_LINEAR);
    const gsf_image to = gsf_wrap_image(back, GSF_F32, W, H, 3);
    CHECK_OK(c, gsf_convert_image(c, &views[0].image, &to));
    for (int k = 0; k < W * H * 3; k++) CHECK_NEAR(back[k], coded[k], 1e-5);
    gsf_destroy_image(c, &views[0].image);
}

static double error_of(gsf_context* c, const gsf_splats* truth, const gsf_splats* splats) { // mean over the photos
    static float a[W * H * 3], b[W * H * 3];
    double sum = 0.0;
    for (int i = 0; i < PHOTOS; i++) {
        render(c, truth, i, a);
        render(c, splats, i, b);
        for (int k = 0; k < W * H * 3; k++) sum += std::fabs((double)a[k] - (double)b[k]) / (W * H * 3 * PHOTOS);
    }
    return sum;
}

static int run_engine(const std::string& folder, const char* milliseconds, const char* workers) {
    std::string name = "engine", at = folder, budget = milliseconds, threads = workers;
    char* arguments[] = {&name[0], &at[0], &budget[0], &threads[0]};
    memset(&engine, 0, sizeof engine);
    return engine_main(4, arguments);
}

int main() {
    gsf_context c = {};
    gsf_splats truth, start, made;
    void* bytes[2] = {NULL, NULL};
    size_t sizes[2] = {0, 0};
    CHECK_OK(&c, gsf_init_context(&c));
    make_splats(&c, 1, &truth);
    make_splats(&c, 2, &start);
    for (int i = 0; i < PHOTOS; i++) take_photo(&c, &truth, i);
    CHECK_OK(&c, gsf_splat_save(&c, test_scratch("start.ply"), &start, NULL));
    const std::string saved = test_scratch("splats.ply"), folder = std::filesystem::path(saved).parent_path().string();
    CHECK(run_engine(folder + "/nowhere", "0", "1") == 1);
    for (int i = 0; i < 2; i++) {
        std::filesystem::remove(saved);
        CHECK(run_engine(folder, i ? "0" : "1", i ? "1" : "3") == 0);
        CHECK_OK(&c, gsf_read_file(&c, saved.c_str(), &bytes[i], &sizes[i]));
    }
    CHECK(sizes[0] == sizes[1] && sizes[0] > 0 && memcmp(bytes[0], bytes[1], sizes[0]) == 0);
    if (CHECK_OK(&c, gsf_splat_load(&c, saved.c_str(), &made))) {
        CHECK(error_of(&c, &truth, &made) < 0.25 * error_of(&c, &truth, &start));
        gsf_splat_destroy(&c, &made);
    }
    std::filesystem::file_time_type seen = {}; // nothing is loaded twice, and a file that is none leaves what there is
    gsf_splats shown = {};
    CHECK_OK(&c, reload(&c, saved, &seen, &shown));
    const float* means = shown.means;
    CHECK_OK(&c, reload(&c, saved, &seen, &shown));
    CHECK(shown.means == means && shown.count > 0);
    CHECK_OK(&c, gsf_write_file(&c, saved.c_str(), "ply", 3));
    std::filesystem::last_write_time(saved, seen + std::chrono::seconds(2));
    CHECK(reload(&c, saved, &seen, &shown) != GSF_OK && shown.means == means);
    gsf_splat_destroy(&c, &shown);
    std::thread interrupt([&] { // as Ctrl-C, once the handler is there
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
        for (int i = 0; i < 2000 && !engine.initialized; i++) std::this_thread::sleep_for(std::chrono::milliseconds(1));
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
        gsf_request_cancel(&engine);
    });
    CHECK(run_engine(folder, "0", "2") == 0);
    interrupt.join();
    CHECK_OK(&c, gsf_splat_load(&c, saved.c_str(), &made));
    gsf_splat_destroy(&c, &made);
    for (void* block : bytes) gsf_free(&c, block);
    gsf_splat_destroy(&c, &truth);
    gsf_splat_destroy(&c, &start);
    return test_report();
}
