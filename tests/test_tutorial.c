// The restorer of README's tutorial: a clip of a legal size is returned unchanged, its confidence is the alpha, and a
// cancelled call stops.
#include "readme_restorer.h"
#include "test.h"

enum { W = 16, H = 24, FRAMES = 3 };

static void fill(gsf_image* image, uint64_t* seed) {
    float* values = (float*)image->data;
    for (int64_t i = 0; i < image->width * image->height * image->channels; i++) values[i] = (float)test_random(seed);
}

static int same(const gsf_image* a, const gsf_image* b) {
    return memcmp(a->data, b->data, (size_t)(a->width * a->height * a->channels) * sizeof(float)) == 0;
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    my_model model = {0};
    const gsf_restorer restorer = my_restorer(&model);
    gsf_image color[FRAMES], alpha[FRAMES], out_color[FRAMES], out_confidence[FRAMES];
    gsf_camera cameras[FRAMES];
    gsf_reference photo;
    uint64_t seed = 3;
    memset(&photo, 0, sizeof photo);
    memset(cameras, 0, sizeof cameras);
    for (int i = 0; i < FRAMES; i++) {
        CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_F32, W, H, 3, &color[i]));
        CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_F32, W, H, 1, &alpha[i]));
        CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_F32, W, H, 3, &out_color[i]));
        CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_F32, W, H, 1, &out_confidence[i]));
        fill(&color[i], &seed);
        fill(&alpha[i], &seed);
        cameras[i].w2c[0] = cameras[i].w2c[5] = cameras[i].w2c[10] = cameras[i].w2c[15] = 1.0;
        cameras[i].fx = cameras[i].fy = 20.0;
        cameras[i].cx = 0.5 * W;
        cameras[i].cy = 0.5 * H;
        cameras[i].width = W;
        cameras[i].height = H;
    }
    gsf_restore_window window;
    memset(&window, 0, sizeof window);
    window.struct_size = sizeof window;
    window.frame_count = FRAMES;
    window.color = color;
    window.alpha = alpha;
    window.cameras = cameras;
    window.out_color = out_color;
    window.out_confidence = out_confidence;

    CHECK_OK(&ctx, restorer.begin_fn(restorer.user, &ctx, &photo, 1));
    CHECK(model.photos == 1);
    CHECK_OK(&ctx, gsf_restore_clip(&ctx, &restorer, &window));
    for (int i = 0; i < FRAMES; i++) CHECK(same(&color[i], &out_color[i]) && same(&alpha[i], &out_confidence[i]));
    gsf_request_cancel(&ctx);
    CHECK(gsf_restore_clip(&ctx, &restorer, &window) == GSF_ERROR_CANCELLED);
    gsf_clear_cancel(&ctx);
    restorer.end_fn(restorer.user, &ctx);
    CHECK(model.photos == 0);
    for (int i = 0; i < FRAMES; i++) {
        gsf_destroy_image(&ctx, &color[i]);
        gsf_destroy_image(&ctx, &alpha[i]);
        gsf_destroy_image(&ctx, &out_color[i]);
        gsf_destroy_image(&ctx, &out_confidence[i]);
    }
    return test_report();
}
