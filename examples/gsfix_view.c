// gsfix_view.c - gsfix view: a window that shows splats, or a scene while it is trained. Part of gsfix; needs SDL2
// (GSFIX_USE_SDL2), without which the command says so.
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#ifndef GSFIX_USE_SDL2

int gsfix_run_view(gsfix_app* app) {
    (void)app;
    fprintf(stderr, "gsfix view: this build has no window system (SDL2, -DGSFIX_USE_SDL2)\n");
    return 1;
}

#else

#define SDL_MAIN_HANDLED
#include <SDL.h>
#include <math.h>

#include "gsfix_orbit.h"

enum { VIEW_COLOR, VIEW_DEPTH, VIEW_ALPHA, VIEW_ERROR, VIEW_REPAIRED, VIEW_MODES };

static const char* const view_names[VIEW_MODES] = {"color", "depth", "opacity", "error", "repaired"};
static const char view_help[] =
    "left drag: orbit   right drag: pan   wheel: closer   W A S D Q E: fly   N: next photo   1: color   2: depth\n"
    "3: opacity   4: error against the photo   5: last repaired frame   space: pause the training   P: save a picture\n";

typedef struct viewer {
    gsfix_app* app;
    gsf_context* ctx;
    SDL_Window* window;
    SDL_Renderer* renderer;
    SDL_Texture* texture;
    int width, height, texture_width, texture_height;
    // what is shown
    gsf_splats splats; // as loaded; of a scene, those that training begins with
    gsf_rasterizer* rasterizer;
    gsf_render_desc desc;
    gsf_scene scene;
    gsfix_split split;
    gsf_train_view* views;
    gsf_restorer restorer;
    gsf_fixer* fixer; // of a scene
    gsf_fix_stats stats;
    gsf_train_stats last; // of the last training step
    gsf_image repaired; // a frame of the last window, copied
    // where from
    gsfix_orbit at;
    size_t photo;  // of the training views, SIZE_MAX: the camera is at none
    int mode, paused, quit, stale; // stale: the picture is older than camera, mode or splats
    int moving;                    // while a button or key is down, slow pictures have half the resolution
    double seconds;                // of the last full picture
    double drawn;                  // gsfix_now() then
    float* losses;                 // (loss_room) mean of each of the run's parts
    size_t loss_count, loss_room, loss_every;
    double loss_sum;
} viewer;

// ---- camera ----------------------------------------------------------------------

static void view_moved(viewer* v) {
    v->photo = SIZE_MAX;
    v->stale = 1;
    if (v->mode == VIEW_ERROR) v->mode = VIEW_COLOR;
}

static void view_shift(viewer* v, int axis, double distance, int with_pivot) {
    orbit_shift(&v->at, axis, distance, with_pivot);
    view_moved(v);
}

static void view_from(viewer* v, const gsf_camera* from) {
    orbit_from(&v->at, from, v->width, v->height);
    v->stale = 1;
}

static void view_photo(viewer* v, size_t photo) {
    view_from(v, &v->views[photo].camera);
    v->photo = photo;
}

// ---- what is shown ---------------------------------------------------------------

static gsf_result view_open_splats(viewer* v) {
    double radius;
    gsf_result result = gsf_splat_load(v->ctx, v->app->o.inputs[0], &v->splats);
    if (result == GSF_OK && !v->splats.count) result = gsf_fail(v->ctx, GSF_ERROR_DEGENERATE, "no splats to show");
    if (result == GSF_OK) result = orbit_face(v->ctx, &v->at, &v->splats, v->width, v->height, &radius);
    if (result != GSF_OK) return result;
    v->stale = 1;
    v->desc.near_plane = (float)(0.02 * radius);
    v->desc.antialiased = v->splats.antialiased;
    if (!v->app->o.background) memcpy(v->desc.background, v->splats.background, sizeof v->desc.background);
    return GSF_OK;
}

static gsf_result view_open_scene(viewer* v, const gsfix_setup* setup) {
    gsf_context* ctx = v->ctx;
    gsf_fix_desc desc = setup->fix;
    double radius;
    int has_restorer = 0;
    gsf_result result = gsfix_load_scene(v->app, v->app->o.inputs[0], &v->scene);
    if (result == GSF_OK) result = gsfix_split_scene(v->app, &v->scene, &v->split);
    if (result == GSF_OK) result = gsfix_make_restorer(v->app, &v->restorer, &has_restorer);
    if (result == GSF_OK) result = gsf_splat_load_train_views(ctx, &v->scene, v->split.train, v->split.train_count, &v->views);
    if (result == GSF_OK)
        result = gsf_splat_make_initial_splats(ctx, &v->scene, v->split.train, v->split.train_count, &setup->initial,
                                               &v->splats, NULL);
    if (result == GSF_OK) result = orbit_set_pivot(ctx, &v->at, &v->splats, &radius);
    if (result != GSF_OK) return result;
    gsfix_settle_train(&desc.train, setup->initial.kind, v->split.train_count);
    desc.train.render.near_plane =
        gsf_splat_measure_near_plane(&v->scene.views[0].camera, sizeof v->scene.views[0], v->scene.view_count);
    v->desc = desc.train.render;
    orbit_set_up(&v->at, v->views, v->split.train_count);
    v->loss_every = (size_t)desc.train.iterations / 256 + 1;
    v->loss_room = (size_t)desc.train.iterations / v->loss_every + 1;
    v->losses = (float*)gsf_alloc_zeroed(ctx, v->loss_room, sizeof *v->losses);
    if (!v->losses) return GSF_ERROR_OUT_OF_MEMORY;
    view_photo(v, 0);
    return gsf_splat_make_fixer(ctx, &desc, v->views, v->split.train_count, &v->splats, has_restorer ? &v->restorer : NULL,
                                &v->fixer);
}

static gsf_result view_keep_repaired(viewer* v) { // the frame in the middle of the window
    const gsf_image* frame = v->stats.restored + v->stats.frame_count / 2;
    gsf_destroy_image(v->ctx, &v->repaired);
    const gsf_result result = gsf_make_image(v->ctx, GSF_F32, frame->width, frame->height, 3, &v->repaired);
    return result == GSF_OK ? gsf_convert_image(v->ctx, frame, &v->repaired) : result;
}

// Trains for `budget` seconds.
static gsf_result view_train(viewer* v, double budget) {
    const double begin = gsfix_now();
    while (v->stats.stage != GSF_FIX_DONE) {
        const gsf_result result = gsf_splat_step_fixer(v->ctx, v->fixer, &v->stats);
        if (result != GSF_OK) return result;
        if (v->stats.stage == GSF_FIX_RESTORE && v->stats.restored) {
            const gsf_result kept = view_keep_repaired(v);
            if (kept != GSF_OK) return kept;
        }
        if (v->stats.stage == GSF_FIX_TRAIN) {
            v->last = v->stats.train;
            v->loss_sum += v->last.loss;
            if ((size_t)v->last.iteration % v->loss_every == 0 && v->loss_count < v->loss_room) {
                v->losses[v->loss_count++] = (float)(v->loss_sum / (double)v->loss_every);
                v->loss_sum = 0.0;
            }
        }
        if (gsfix_now() - begin > budget) break;
    }
    return GSF_OK;
}

// ---- the picture -----------------------------------------------------------------

static gsf_result view_render(viewer* v, const gsf_camera* camera, const gsf_render_output* out) {
    if (v->fixer) return gsf_splat_render_trainer(v->ctx, gsf_splat_get_trainer(v->fixer), camera, out);
    return gsf_splat_render(v->ctx, v->rasterizer, &v->splats, camera, &v->desc, out);
}

// |render - photo|, three times as bright, at the photo's own size.
static gsf_result view_make_error(viewer* v, gsf_image* out) {
    const gsf_train_view* view = v->views + v->photo;
    gsf_image photo;
    gsf_render_output images = {0};
    gsf_result result = gsf_make_image(v->ctx, GSF_F32, view->camera.width, view->camera.height, 3, out);
    if (result != GSF_OK) return result;
    result = gsf_make_image(v->ctx, GSF_F32, view->camera.width, view->camera.height, 3, &photo);
    if (result != GSF_OK) return result;
    images.color = *out;
    result = gsf_convert_image(v->ctx, &view->image, &photo);
    if (result == GSF_OK) result = view_render(v, &view->camera, &images);
    float *a = (float*)out->data, *b = (float*)photo.data;
    for (int64_t i = 0; i < 3 * out->width * out->height; i++) a[i] = 3.0f * fabsf(a[i] - b[i]);
    gsf_destroy_image(v->ctx, &photo);
    return result;
}

// Makes the picture of the current mode, u8 or f32 with 3 channels, 1 / `detail` of the window's size (or the frame's).
static gsf_result view_make_picture(viewer* v, int detail, gsf_image* out) {
    const int width = (v->width + detail - 1) / detail, height = (v->height + detail - 1) / detail;
    const gsf_camera camera = gsf_resize_camera(&v->at.camera, width, height);
    gsf_render_output images = {0};
    gsf_image plane = {0};
    if (v->mode == VIEW_ERROR && v->photo != SIZE_MAX) return view_make_error(v, out);
    if (v->mode == VIEW_REPAIRED && v->repaired.data) {
        *out = v->repaired;
        out->owned = NULL;
        return GSF_OK;
    }
    const int color = v->mode != VIEW_DEPTH && v->mode != VIEW_ALPHA;
    gsf_result result = gsf_make_image(v->ctx, GSF_F32, camera.width, camera.height, color ? 3 : 1, color ? out : &plane);
    if (result != GSF_OK) return result;
    *(color ? &images.color : v->mode == VIEW_DEPTH ? &images.depth : &images.alpha) = color ? *out : plane;
    result = view_render(v, &camera, &images);
    if (result == GSF_OK && v->mode == VIEW_DEPTH) result = gsfix_color_depth(v->ctx, &plane, out);
    if (result == GSF_OK && v->mode == VIEW_ALPHA) {
        result = gsf_make_image(v->ctx, GSF_F32, camera.width, camera.height, 3, out);
        if (result == GSF_OK) result = gsf_convert_image(v->ctx, &plane, out);
    }
    gsf_destroy_image(v->ctx, &plane);
    return result;
}

static void view_draw_losses(viewer* v) { // lower left, on a logarithmic scale
    const int width = 256, height = 72, left = 12, top = v->height - height - 12;
    const SDL_Rect box = {left - 4, top - 4, width + 8, height + 8};
    float least = 1.0f, most = 1e-6f;
    for (size_t i = 0; i < v->loss_count; i++) {
        least = fminf(least, v->losses[i]);
        most = fmaxf(most, v->losses[i]);
    }
    SDL_SetRenderDrawBlendMode(v->renderer, SDL_BLENDMODE_BLEND);
    SDL_SetRenderDrawColor(v->renderer, 0, 0, 0, 150);
    SDL_RenderFillRect(v->renderer, &box);
    SDL_SetRenderDrawColor(v->renderer, 120, 200, 255, 255);
    const double span = log((double)most / (double)fmaxf(least, 1e-6f)) + 1e-9;
    int before = 0;
    for (size_t i = 0; i < v->loss_count; i++) {
        const int y = top + (int)(height * log((double)(most / v->losses[i])) / span);
        const int x = left + (int)(i * (size_t)width / v->loss_room);
        if (i) SDL_RenderDrawLine(v->renderer, x - 1, before, x, y);
        before = y;
    }
}

static void view_title(viewer* v) {
    char text[256], train[96] = "";
    const size_t count = v->last.splats ? v->last.splats : v->splats.count;
    if (v->fixer)
        snprintf(train, sizeof train, "  |  %s step %d, loss %.4f%s", v->stats.stage == GSF_FIX_DONE ? "done," : "training,",
                 (int)v->last.iteration, v->last.loss, v->paused ? " (paused)" : "");
    snprintf(text, sizeof text, "gsfix view  |  %s%s  |  %zu splats  |  %.0f ms a picture", view_names[v->mode], train, count,
             1e3 * v->seconds);
    SDL_SetWindowTitle(v->window, text);
}

// Draws the picture into the window. Frames of another shape keep theirs.
static gsf_result view_draw(viewer* v) {
    const int detail = v->moving && v->seconds > 0.05 ? 2 : 1;
    const double begin = gsfix_now();
    gsf_image picture = {0}, bytes = {0};
    gsf_result result = view_make_picture(v, detail, &picture);
    if (result == GSF_OK) result = gsf_make_image(v->ctx, GSF_U8, picture.width, picture.height, 3, &bytes);
    if (result == GSF_OK) result = gsf_convert_image(v->ctx, &picture, &bytes);
    if (result == GSF_OK) {
        if (detail == 1) v->seconds = gsfix_now() - begin;
        const int width = (int)bytes.width, height = (int)bytes.height;
        if (!v->texture || v->texture_width != width || v->texture_height != height) {
            if (v->texture) SDL_DestroyTexture(v->texture);
            v->texture = SDL_CreateTexture(v->renderer, SDL_PIXELFORMAT_RGB24, SDL_TEXTUREACCESS_STREAMING, width, height);
            v->texture_width = width;
            v->texture_height = height;
        }
        if (v->texture) SDL_UpdateTexture(v->texture, NULL, bytes.data, 3 * width);
        const double scale = fmin((double)v->width / width, (double)v->height / height);
        const SDL_Rect to = {(int)(v->width - scale * width) / 2, (int)(v->height - scale * height) / 2, (int)(scale * width),
                             (int)(scale * height)};
        SDL_SetRenderDrawColor(v->renderer, 24, 24, 24, 255);
        SDL_RenderClear(v->renderer);
        if (v->texture) SDL_RenderCopy(v->renderer, v->texture, NULL, &to);
        if (v->fixer) view_draw_losses(v);
        view_title(v);
        v->drawn = gsfix_now();
        v->stale = detail > 1; // to be drawn again when nothing moves
    }
    gsf_destroy_image(v->ctx, &picture);
    gsf_destroy_image(v->ctx, &bytes);
    return result;
}

// Saves the window's pixels, the curve included. Called between drawing and presenting.
static gsf_result view_save(viewer* v, const char* path) {
    gsf_image image;
    gsf_result result = gsf_make_image(v->ctx, GSF_U8, v->width, v->height, 3, &image);
    if (result == GSF_OK && SDL_RenderReadPixels(v->renderer, NULL, SDL_PIXELFORMAT_RGB24, image.data, 3 * v->width) != 0)
        result = gsf_fail(v->ctx, GSF_ERROR_IO, "%s: %s", path, SDL_GetError());
    if (result == GSF_OK) result = gsf_save_image(v->ctx, path, &image);
    if (result == GSF_OK) gsfix_print(v->app, "saved %s", path);
    gsf_destroy_image(v->ctx, &image);
    return result;
}

static gsf_result view_save_next(viewer* v) { // under a name that does not exist yet, in the current folder
    for (int i = 1; i < 10000; i++) {
        const gsfix_path path = gsfix_pathf("view_%04d.png", i);
        FILE* file = fopen(path.s, "rb");
        if (!file) return view_save(v, path.s);
        fclose(file);
    }
    return GSF_OK;
}

// ---- events ----------------------------------------------------------------------

static gsf_result view_key(viewer* v, SDL_Keycode key) {
    const double step = 0.04 * orbit_distance(&v->at);
    if (key >= SDLK_1 && key < SDLK_1 + VIEW_MODES) {
        v->mode = (int)(key - SDLK_1);
        if (v->mode == VIEW_ERROR && v->views && v->photo == SIZE_MAX) view_photo(v, 0);
        v->stale = 1;
    }
    switch (key) {
        case SDLK_ESCAPE: v->quit = 1; break;
        case SDLK_SPACE: v->paused = !v->paused; v->stale = 1; break;
        case SDLK_n:
            if (v->views) view_photo(v, v->photo == SIZE_MAX ? 0 : (v->photo + 1) % v->split.train_count);
            break;
        case SDLK_p: return view_save_next(v);
        case SDLK_w: view_shift(v, 2, step, 1); break;
        case SDLK_s: view_shift(v, 2, -step, 1); break;
        case SDLK_d: view_shift(v, 0, step, 1); break;
        case SDLK_a: view_shift(v, 0, -step, 1); break;
        case SDLK_e: view_shift(v, 1, -step, 1); break;
        case SDLK_q: view_shift(v, 1, step, 1); break;
        default: break;
    }
    return GSF_OK;
}

static void view_drag(viewer* v, const SDL_MouseMotionEvent* m) {
    if (m->state & SDL_BUTTON_LMASK) {
        orbit_drag(&v->at, m->xrel, m->yrel);
        view_moved(v);
    } else if (m->state & (SDL_BUTTON_RMASK | SDL_BUTTON_MMASK)) {
        const double pixel = orbit_distance(&v->at) / v->at.camera.fx;
        view_shift(v, 0, -pixel * m->xrel, 1);
        view_shift(v, 1, -pixel * m->yrel, 1);
    }
}

static void view_resize(viewer* v) {
    const gsf_camera before = v->at.camera;
    SDL_GetRendererOutputSize(v->renderer, &v->width, &v->height);
    if (v->width < 16) v->width = 16;
    if (v->height < 16) v->height = 16;
    view_from(v, &before);
}

static gsf_result view_events(viewer* v) {
    SDL_Event event;
    gsf_result result = GSF_OK;
    while (result == GSF_OK && SDL_PollEvent(&event)) {
        if (event.type == SDL_QUIT) v->quit = 1;
        else if (event.type == SDL_KEYDOWN) result = view_key(v, event.key.keysym.sym);
        else if (event.type == SDL_MOUSEMOTION) view_drag(v, &event.motion);
        else if (event.type == SDL_MOUSEWHEEL)
            view_shift(v, 2, event.wheel.y * 0.1 * orbit_distance(&v->at), 0);
        else if (event.type == SDL_WINDOWEVENT && event.window.event == SDL_WINDOWEVENT_SIZE_CHANGED) view_resize(v);
        else if (event.type == SDL_WINDOWEVENT && event.window.event == SDL_WINDOWEVENT_EXPOSED) v->stale = 1;
    }
    int keys = 0;
    const uint8_t* down = SDL_GetKeyboardState(&keys);
    v->moving = SDL_GetMouseState(NULL, NULL) != 0;
    for (int i = 0; i < keys; i++) v->moving |= down[i];
    return result;
}

// ---- the command -----------------------------------------------------------------

static gsf_result view_open_window(viewer* v) {
    SDL_SetMainReady();
    v->width = 960;
    v->height = 640;
    if (SDL_Init(SDL_INIT_VIDEO) != 0) return gsf_fail(v->ctx, GSF_ERROR_UNSUPPORTED, "no window: %s", SDL_GetError());
    v->window = SDL_CreateWindow("gsfix view", SDL_WINDOWPOS_CENTERED, SDL_WINDOWPOS_CENTERED, v->width, v->height,
                                 SDL_WINDOW_RESIZABLE | SDL_WINDOW_ALLOW_HIGHDPI);
    if (v->window) v->renderer = SDL_CreateRenderer(v->window, -1, 0);
    if (!v->renderer && v->window) v->renderer = SDL_CreateRenderer(v->window, -1, SDL_RENDERER_SOFTWARE);
    if (!v->renderer) return gsf_fail(v->ctx, GSF_ERROR_UNSUPPORTED, "no window: %s", SDL_GetError());
    SDL_GetRendererOutputSize(v->renderer, &v->width, &v->height);
    return GSF_OK;
}

static gsf_result view_mean_psnr(viewer* v, double* out) { // of the photos
    *out = 0.0;
    for (size_t i = 0; i < v->split.train_count; i++) {
        const gsf_train_view* view = v->views + i;
        gsf_render_output images = {0};
        double psnr = 0.0;
        gsf_result result = gsf_make_image(v->ctx, GSF_F32, view->camera.width, view->camera.height, 3, &images.color);
        if (result == GSF_OK) result = view_render(v, &view->camera, &images);
        if (result == GSF_OK) result = gsf_measure_image(v->ctx, GSF_METRIC_PSNR, &images.color, &view->image, NULL, &psnr);
        gsf_destroy_image(v->ctx, &images.color);
        if (result != GSF_OK) return result;
        *out += psnr / (double)v->split.train_count;
    }
    return GSF_OK;
}

// With --screenshot: trains to the end, orbits, saves the picture.
static gsf_result view_shoot(viewer* v) {
    double before = 0.0, after = 0.0;
    gsf_result result = gsfix_claim_file(v->app, v->app->o.screenshot);
    if (result == GSF_OK && v->fixer) result = view_mean_psnr(v, &before);
    while (result == GSF_OK && v->fixer && v->stats.stage != GSF_FIX_DONE) {
        result = view_train(v, 0.25);
        if (result == GSF_OK) result = view_events(v);
        if (result == GSF_OK) result = view_draw(v);
        SDL_RenderPresent(v->renderer);
    }
    if (result == GSF_OK && v->fixer) result = view_mean_psnr(v, &after);
    if (result == GSF_OK && v->fixer) {
        gsfix_json_number(v->ctx, &v->app->json, "psnr_before", before);
        gsfix_json_number(v->ctx, &v->app->json, "psnr", after);
        gsfix_print(v->app, "photos: %.2f dB before, %.2f dB after %d steps", before, after, (int)v->last.iteration);
    }
    if (v->app->o.orbit != 0.0) {
        orbit_turn(&v->at, v->at.up, v->app->o.orbit * 3.14159265358979 / 180.0);
        view_moved(v);
    }
    if (result == GSF_OK) result = view_draw(v);
    return result == GSF_OK ? view_save(v, v->app->o.screenshot) : result;
}

static gsf_result view_loop(viewer* v) {
    fputs(view_help, stderr);
    while (!v->quit) {
        const int training = v->fixer && !v->paused && v->stats.stage != GSF_FIX_DONE;
        gsf_result result = view_events(v);
        if (result == GSF_OK && training) result = view_train(v, v->moving ? 0.0 : 0.05);
        if (result == GSF_OK && (v->stale || (training && gsfix_now() - v->drawn > 0.2 + v->seconds))) {
            result = view_draw(v);
            SDL_RenderPresent(v->renderer);
        } else if (!training) {
            SDL_Delay(5);
        }
        if (result != GSF_OK) return result;
    }
    return GSF_OK;
}

static void view_close(viewer* v) {
    gsf_splat_destroy_fixer(v->ctx, v->fixer);
    gsf_destroy_restorer(v->ctx, &v->restorer);
    gsf_splat_destroy_rasterizer(v->ctx, v->rasterizer);
    gsf_splat_destroy(v->ctx, &v->splats);
    gsf_destroy_image(v->ctx, &v->repaired);
    gsf_free(v->ctx, v->losses);
    gsf_free(v->ctx, v->views);
    gsfix_free_split(v->app, &v->split);
    gsf_splat_destroy_scene(v->ctx, &v->scene);
    if (v->texture) SDL_DestroyTexture(v->texture);
    if (v->renderer) SDL_DestroyRenderer(v->renderer);
    if (v->window) SDL_DestroyWindow(v->window);
    SDL_Quit();
}

int gsfix_run_view(gsfix_app* app) {
    static const viewer zero;
    viewer v = zero;
    gsfix_setup setup;
    const int is_scene = gsfix_is_folder(app->o.inputs[0]);
    const int code = is_scene ? gsfix_resolve_setup(app, &setup) : gsfix_splats_background(app, v.desc.background);
    if (code) return code;
    const char* r = app->o.restorer;
    if (r && (!is_scene || strncmp(r, "dit:", 4) == 0 || strncmp(r, "exec:", 5) == 0)) // these need an output folder
        return gsfix_misused(app, "--restorer %s: view takes none|warp|mini[:FILE], and a scene", r);
    if (app->o.orbit != 0.0 && !app->o.screenshot) return gsfix_misused(app, "--orbit: only with --screenshot");
    v.app = app;
    v.ctx = &app->ctx;
    v.photo = SIZE_MAX;
    gsf_result result = view_open_window(&v);
    if (result == GSF_OK) result = gsf_splat_make_rasterizer(v.ctx, &v.rasterizer);
    if (result == GSF_OK) result = is_scene ? view_open_scene(&v, &setup) : view_open_splats(&v);
    if (result == GSF_OK) result = app->o.screenshot ? view_shoot(&v) : view_loop(&v);
    view_close(&v);
    return result == GSF_OK ? 0 : gsfix_failed(app);
}

#endif
