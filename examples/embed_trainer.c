// embed_trainer.c - cc -O2 -std=c11 -fopenmp -DGSFIXER_IMPLEMENTATION -I. examples/embed_trainer.c -o embed_trainer -lm
// The splat trainer inside a host's frame loop: a few training steps and one render of the current state per frame.
//     embed_trainer [SCENE [OUT.ply [FRAMES]]]
// SCENE is a COLMAP folder; without one the program trains on renders of random splats. Ctrl-C stops early and saves.
#include "gsfixer_splat.h"

#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>

enum { STEPS_PER_FRAME = 10, PREVIEW_WIDTH = 160, PREVIEW_HEIGHT = 120 };

typedef struct host {
    gsf_context ctx;
    gsf_scene scene;
    gsf_train_view* views;
    size_t view_count;
    gsf_splats start; // initial splats
    gsf_trainer* trainer;
} host;

static gsf_context* interrupted;
static void on_interrupt(int signal_number) {
    (void)signal_number;
    gsf_request_cancel(interrupted);
}

static gsf_result fill_random_splats(gsf_context* ctx, uint64_t seed, size_t count, gsf_splats* out) {
    gsf_result result = gsf_splat_make(ctx, count, 0, out);
    for (size_t i = 0; i < out->count; i++) {
        for (uint64_t a = 0; a < 3; a++) {
            out->means[3 * i + a] = (float)(2.0 * gsf_draw_uniform(seed, a, i) - 1.0);
            out->log_scales[3 * i + a] = (float)(-3.5 + gsf_draw_uniform(seed, 3 + a, i));
            out->sh[3 * i + a] = (float)gsf_draw_normal(seed, 6 + a, i);
        }
        out->quats[4 * i] = 1.0f;
    }
    return result;
}

// Synthetic photos: random splats rendered from 4 cameras.
static gsf_result make_random_views(host* h) {
    gsf_context* ctx = &h->ctx;
    gsf_splats truth = {0};
    gsf_rasterizer* rasterizer = NULL;
    gsf_result result = fill_random_splats(ctx, 1, 400, &truth);
    if (result == GSF_OK) result = gsf_splat_make_rasterizer(ctx, &rasterizer);
    h->view_count = 4;
    h->views = (gsf_train_view*)gsf_alloc_zeroed(ctx, h->view_count, sizeof *h->views);
    if (!h->views) result = GSF_ERROR_OUT_OF_MEMORY;
    for (size_t v = 0; v < h->view_count && result == GSF_OK; v++) {
        const double c = cos(0.3 * (double)v), s = sin(0.3 * (double)v);
        gsf_camera camera = {{c, 0, -s, 0, 0, 1, 0, 0, s, 0, c, 0, 0, 0, 4, 1}, 150, 150, 80, 60, 160, 120};
        h->views[v].camera = camera;
        result = gsf_make_image(ctx, GSF_F32, camera.width, camera.height, 3, &h->views[v].image);
        gsf_render_output out = {0};
        out.color = h->views[v].image;
        if (result == GSF_OK) result = gsf_splat_render(ctx, rasterizer, &truth, &camera, NULL, &out);
    }
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    gsf_splat_destroy(ctx, &truth);
    return result == GSF_OK ? fill_random_splats(ctx, 2, 400, &h->start) : result;
}

static gsf_result load_views(host* h, const char* path) {
    gsf_context* ctx = &h->ctx;
    gsf_scene_desc desc = {0};
    desc.max_size = 480;
    gsf_result result = gsf_splat_load_scene(ctx, path, &desc, &h->scene);
    if (result != GSF_OK) return result;
    h->views = (gsf_train_view*)gsf_alloc_zeroed(ctx, h->scene.view_count, sizeof *h->views);
    if (!h->views) return GSF_ERROR_OUT_OF_MEMORY;
    for (; h->view_count < h->scene.view_count; h->view_count++) {
        result = gsf_splat_load_view_image(ctx, &h->scene, h->view_count);
        if (result != GSF_OK) return result;
        h->views[h->view_count].camera = h->scene.views[h->view_count].camera;
        h->views[h->view_count].image = h->scene.views[h->view_count].image;
        h->views[h->view_count].image.owned = NULL; // owned by the scene
    }
    return gsf_splat_make_from_points(ctx, h->scene.points, h->scene.colors, h->scene.point_count, NULL, 2,
                                      h->scene.origin, &h->start);
}

static gsf_result run_frames(host* h, int frames) {
    static float preview[PREVIEW_WIDTH * PREVIEW_HEIGHT * 3];
    gsf_render_output out = {0};
    out.color = gsf_wrap_image(preview, GSF_F32, PREVIEW_WIDTH, PREVIEW_HEIGHT, 3);
    gsf_train_stats stats = {0};
    for (int frame = 0; frame < frames; frame++) {
        for (int i = 0; i < STEPS_PER_FRAME; i++) { // a real host would stop when its time budget is used up
            const gsf_result result = gsf_splat_step_trainer(&h->ctx, h->trainer, &stats);
            if (result != GSF_OK) return result;
        }
        const gsf_camera* shot = &h->views[(size_t)frame % h->view_count].camera;
        const gsf_camera camera = gsf_resize_camera(shot, PREVIEW_WIDTH, PREVIEW_HEIGHT);
        const gsf_result result = gsf_splat_render_trainer(&h->ctx, h->trainer, &camera, &out);
        if (result != GSF_OK) return result;
        double mean = 0.0; // a real host would display the image
        const size_t values = sizeof preview / sizeof preview[0];
        for (size_t i = 0; i < values; i++) mean += (double)preview[i] / (double)values;
        printf("frame %3d  iteration %4d  %6zu splats  loss %.4f  mean brightness %.3f\n", frame, (int)stats.iteration,
               stats.splats, stats.loss, mean);
    }
    return GSF_OK;
}

int main(int argc, char** argv) {
    host h = {0};
    const int frames = argc > 3 ? atoi(argv[3]) : 20;
    if (argc > 4 || frames < 1) return fprintf(stderr, "usage: %s [SCENE [OUT.ply [FRAMES]]]\n", argv[0]), 2;
    gsf_result result = gsf_init_context(&h.ctx);
    interrupted = &h.ctx;
    signal(SIGINT, on_interrupt);
    if (result == GSF_OK) result = argc > 1 ? load_views(&h, argv[1]) : make_random_views(&h);

    gsf_train_desc desc = {0};
    desc.iterations = frames * STEPS_PER_FRAME;
    if (result == GSF_OK)
        result = gsf_splat_make_trainer(&h.ctx, &desc, h.views, h.view_count, &h.start, &h.trainer);
    if (result == GSF_OK) result = run_frames(&h, frames);
    if (result == GSF_ERROR_CANCELLED) { // the splats are complete and usable after every step
        gsf_clear_cancel(&h.ctx);
        result = GSF_OK;
    }
    if (result == GSF_OK && argc > 2)
        result = gsf_splat_save(&h.ctx, argv[2], gsf_splat_get_trained(h.trainer), NULL);
    if (result != GSF_OK) fprintf(stderr, "%s\n", h.ctx.error);

    gsf_splat_destroy_trainer(&h.ctx, h.trainer);
    gsf_splat_destroy(&h.ctx, &h.start);
    for (size_t v = 0; v < h.view_count; v++) gsf_destroy_image(&h.ctx, &h.views[v].image);
    gsf_free(&h.ctx, h.views);
    gsf_splat_destroy_scene(&h.ctx, &h.scene);
    return result == GSF_OK ? 0 : 1;
}
