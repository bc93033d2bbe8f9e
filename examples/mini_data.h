// mini_data.h - training data for the restorer mini, made from seeds. Part of train_mini.c.
// SPDX-License-Identifier: MIT
/* A scene is a made scene (make_scene.c), splats fitted to a few of its photos by the repair loop, and frames of the loop's own
   path as a restorer gets them, just before the loop's rounds, with the photos carried into them and the ray-traced truth.
   Frames from behind a wall, where the loop's path may go, are left out: no restorer could know that the wall is there.
   The file of a scene has one tensor, "frames": u8 (frames, height, width, 50), per pixel

       render 3 | alpha | nearness | truth 3 |
       3 times: photo 3, residual 3, score, depth ratio, angle, photo by the frame's depth 3, its validity, its depth ratio

   that is the planes of gsf__mini_input, those within [-1,1] shifted by 128. */
#ifndef MINI_DATA_H
#define MINI_DATA_H

#define MAKE_SCENE_NO_MAIN
#include "make_scene.c"

enum { DATA_REFERENCES = 3, DATA_FRAME = GSF__MINI_FRAME + 3, DATA_PIXEL = DATA_FRAME + DATA_REFERENCES * GSF__MINI_REFERENCE };
enum { DATA_VIEWS = 22, DATA_WINDOWS = 4, DATA_WINDOW = 9 };

typedef struct data_desc { // of all scenes
    const char* dir;
    int pixels;      // the longer side, at least, and at most 1.4 times as much; the other is two thirds of it
    int fit;         // step of the last round
    const gsf_restorer* own; // NULL, or a restorer whose frames half of the scenes get in the rounds: then follow frames of the
                             // splats at the end, at cameras of photos that nobody took
} data_desc;

static int data_is_signed(int plane) { // of a reference: kept within [-1,1]
    return (plane >= 3 && plane < 6) || plane == 7 || plane == 13;
}

static uint8_t data_byte(float x, int is_signed) {
    const float v = is_signed ? 128.0f + 127.0f * x : 255.0f * x;
    return (uint8_t)(v <= 0.0f ? 0 : v >= 255.0f ? 255 : (int)(v + 0.5f));
}
static float data_float(uint8_t x, int is_signed) { return is_signed ? ((float)x - 128.0f) / 127.0f : (float)x / 255.0f; }

typedef struct data_probe { // a restorer that restores nothing and writes down what it gets
    world* s;
    const gsf_camera* cameras; // of the photos
    float exposures[DATA_VIEWS]; // of the photos, in stops
    size_t photos;
    int rounds;                // begun
    float help;                // part of the truth in what it returns, so that later rounds see repaired splats
    const gsf_restorer* own;   // NULL, or what restores instead
    int final;                 // after the last step: all frames are taken
    size_t count, room;        // frames; of bytes
    int64_t width, height;
    uint8_t* bytes;
} data_probe;

static gsf_result probe_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                              gsf_restorer_info* out) {
    const gsf_restorer* own = ((data_probe*)user)->own;
    const gsf_result result = own ? own->query_fn(own->user, ctx, frames, width, height, out) : GSF_OK;
    out->needs_depth = out->needs_alpha = 1;
    out->needs_carried = DATA_REFERENCES;
    out->warp_weight = 0.0f; // as when the weights in examples/models were trained
    return result;
}

static gsf_result probe_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    data_probe* p = (data_probe*)user;
    p->rounds++;
    return p->own ? p->own->begin_fn(p->own->user, ctx, references, count) : GSF_OK;
}

static void probe_end(void* user, gsf_context* ctx) {
    const gsf_restorer* own = ((data_probe*)user)->own;
    if (own) own->end_fn(own->user, ctx);
}

// That of the photos around a camera, as carried photos have it (>>carry): exposure changes gradually along a capture.
static float probe_exposure(const data_probe* p, const gsf_camera* camera) {
    double at[3], center[3], sum = 0.0, total = 0.0;
    gsf_get_camera_center(camera, at);
    for (size_t i = 0; i < p->photos; i++) {
        gsf_get_camera_center(p->cameras + i, center);
        double square = 1e-4;
        for (int k = 0; k < 3; k++) square += (at[k] - center[k]) * (at[k] - center[k]);
        sum += (double)p->exposures[i] / square;
        total += 1.0 / square;
    }
    return exp2f((float)(sum / total));
}

// The truth at a camera; the sensor's noise is that of a photo that the scene does not have.
static gsf_result probe_truth(gsf_context* ctx, const data_probe* p, const gsf_camera* camera, uint8_t* out, float* depth,
                              float* normal) {
    photo_job job = {p->s, *camera, 1000 + p->count, out, depth, normal, probe_exposure(p, camera)};
    ctx->parallel.for_fn(ctx->parallel.user, (size_t)camera->height, photo_row, &job);
    return gsf_is_cancelled(ctx) ? GSF_ERROR_CANCELLED : GSF_OK;
}

// Adds up the scores of what a reference shows, and of those that the true surface hides.
static void probe_hidden(const gsf_carried* c, const float* depth, double* hidden, double* all) {
    for (int64_t i = 0; i < c->depth.width * c->depth.height; i++) {
        const float score = ((const float*)c->score.data)[i], z = ((const float*)c->depth.data)[i];
        *all += (double)score;
        if (depth[i] > 0.0f && depth[i] < 0.7f * z) *hidden += (double)score;
    }
}

static gsf_result probe_frame(gsf_context* ctx, data_probe* p, const gsf_restore_window* w, int32_t frame, float* planes,
                              uint8_t* truth) {
    const gsf_image* depth = w->depth + frame;
    const int64_t pixels = depth->width * depth->height;
    float* true_depth = planes + pixels * GSF__MINI_REFERENCE;
    double hidden = 0.0, all = 0.0;
    uint8_t* out = p->bytes + p->count * (size_t)pixels * DATA_PIXEL;
    gsf_result result = probe_truth(ctx, p, w->cameras + frame, truth, true_depth, planes);
    gsf__mini_plane_frame(w->color + frame, w->alpha + frame, depth, planes);
    for (int64_t i = 0; i < pixels; i++) {
        for (int k = 0; k < GSF__MINI_FRAME; k++) out[i * DATA_PIXEL + k] = data_byte(planes[i * GSF__MINI_FRAME + k], 0);
        memcpy(out + i * DATA_PIXEL + GSF__MINI_FRAME, truth + 3 * i, 3);
    }
    for (int32_t slot = 0; slot < DATA_REFERENCES && result == GSF_OK; slot++) {
        gsf_carried carried;
        memset(&carried, 0, sizeof carried);
        result = w->carry_fn(w->carry_user, ctx, frame, slot, &carried);
        if (result != GSF_OK) break;
        memset(planes, 0, (size_t)(pixels * GSF__MINI_REFERENCE) * sizeof(float));
        if (carried.reference >= 0) {
            gsf__mini_plane_reference(&carried, depth, planes);
            probe_hidden(&carried, true_depth, &hidden, &all);
        }
        for (int64_t i = 0; i < pixels; i++)
            for (int k = 0; k < GSF__MINI_REFERENCE; k++)
                out[i * DATA_PIXEL + DATA_FRAME + slot * GSF__MINI_REFERENCE + k] =
                    data_byte(planes[i * GSF__MINI_REFERENCE + k], data_is_signed(k));
    }
    p->count += result == GSF_OK && hidden <= 0.3 * all;
    return result;
}

// Writes down every other frame of a window, or all of them.
static gsf_result probe_restore(void* user, gsf_context* ctx, const gsf_restore_window* w) {
    data_probe* p = (data_probe*)user;
    const int64_t width = w->color[0].width, height = w->color[0].height, pixels = width * height;
    if (!w->carry_fn) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "the loop carries no photos");
    if (!p->bytes) {
        p->width = width;
        p->height = height;
        p->room = (size_t)(pixels * DATA_PIXEL) * (3 * DATA_WINDOWS * DATA_WINDOW + DATA_VIEWS);
        p->bytes = (uint8_t*)gsf_alloc(ctx, p->room, 1);
    }
    float* planes = (float*)gsf_alloc(ctx, (size_t)pixels * (GSF__MINI_REFERENCE + 1), sizeof(float));
    uint8_t* truth = (uint8_t*)gsf_alloc(ctx, (size_t)pixels, 3);
    gsf_result result = p->bytes && planes && truth ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < w->frame_count && result == GSF_OK; i++) {
        float *color = (float*)w->out_color[i].data, *confidence = (float*)w->out_confidence[i].data;
        const int taken = p->final || (w->reference_index[i] < 0 && (i + w->clip + p->rounds) % 2 == 0);
        if (taken) result = probe_frame(ctx, p, w, i, planes, truth);
        for (int64_t k = 0; k < pixels && !p->own; k++) {
            confidence[k] = taken ? p->help : 0.0f;
            for (int64_t c = 3 * k; c < 3 * k + 3; c++) {
                const float render = ((const float*)w->color[i].data)[c];
                color[c] = taken ? render + p->help * ((float)truth[c] / 255.0f - render) : render;
            }
        }
    }
    if (result == GSF_OK && p->own) result = p->own->restore_fn(p->own->user, ctx, w);
    gsf_free(ctx, planes);
    gsf_free(ctx, truth);
    return result;
}

// Takes frames of the splats as they are, at cameras that were not trained on.
static gsf_result data_finish(gsf_context* ctx, gsf_fixer* fixer, const gsf_scene* scene, const uint32_t* train, size_t trained,
                              data_probe* p) {
    enum { MOST = 10 };
    gsf_camera cameras[DATA_VIEWS];
    gsf_image images[2 * MOST];
    size_t count = 0, used = 0;
    memset(images, 0, sizeof images);
    for (uint32_t i = 0; i < scene->view_count; i++) {
        if (used < trained && train[used] == i) used++;
        else cameras[count++] = scene->views[i].camera;
    }
    const size_t taken = count < MOST ? count : MOST;
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < taken; i++) cameras[i] = cameras[i * count / taken];
    for (size_t i = 0; i < 2 * taken && result == GSF_OK; i++)
        result = gsf_make_image(ctx, GSF_F32, cameras[0].width, cameras[0].height, i < taken ? 3 : 1, &images[i]);
    p->final = 1;
    if (result == GSF_OK) result = gsf_splat_restore_views(ctx, &fixer, 1, cameras, taken, images, images + taken);
    for (size_t i = 0; i < 2 * taken; i++) gsf_destroy_image(ctx, &images[i]);
    return result;
}

// The scene's options, from its seed: the layouts take turns.
static make_scene_options data_options(const data_desc* d, uint64_t seed) {
    make_scene_options o = make_scene_defaults;
    const int upright = gsf_draw_uniform(seed, 1, 0) < 0.3;
    const int side = (int)(d->pixels * (1.0 + 0.4 * gsf_draw_uniform(seed, 1, 5)));
    o.seed = seed;
    o.layout = 1 + (int)(seed % (LAYOUTS - 1));
    o.views = DATA_VIEWS;
    o.width = upright ? 2 * side / 3 : side;
    o.height = upright ? side : 2 * side / 3;
    o.points = 1500;
    o.arc = 60.0 + 140.0 * gsf_draw_uniform(seed, 1, 1);
    o.drift = gsf_draw_uniform(seed, 1, 2) < 0.4 ? 0.8 * gsf_draw_uniform(seed, 1, 3) : 0.0;
    return o;
}

// Runs the loop with the probe until its last round is over or, if that restores, to its end.
static gsf_result data_run(gsf_context* ctx, const data_desc* d, const char* folder, const make_scene_options* o,
                           data_probe* p) {
    static const size_t views_of[8] = {3, 3, 4, 3, 5, 6, 9, 12};
    const uint64_t seed = o->seed;
    const double noise = 0.1 + 0.4 * gsf_draw_uniform(seed, 1, 6); // of poses, in pixels
    gsf_restorer restorer = {sizeof restorer, "probe", p, probe_query, probe_begin, probe_restore, probe_end, NULL};
    uint32_t train[DATA_VIEWS], test[DATA_VIEWS];
    gsf_camera cameras[DATA_VIEWS];
    size_t count, held_out;
    gsf_scene scene;
    gsf_train_view* views = NULL;
    gsf_splats start;
    gsf_fixer* fixer = NULL;
    gsf_fix_stats now;
    memset(&start, 0, sizeof start);
    memset(&now, 0, sizeof now);
    gsf_result result = gsf_splat_load_scene(ctx, folder, NULL, &scene);
    gsf_splat_split_views(scene.view_count, 8, views_of[seed % 8], train, &count, test, &held_out);
    for (size_t i = 0; i < count && result == GSF_OK; i++) { // as uncertain as poses from features are
        gsf_camera* camera = &scene.views[train[i]].camera;
        camera->cx += noise * gsf_draw_normal(seed, 2, 2 * i);
        camera->cy += noise * gsf_draw_normal(seed, 2, 2 * i + 1);
        cameras[i] = *camera;
        p->exposures[i] = log2f(exposure_of(o, train[i]));
    }
    p->cameras = cameras;
    p->photos = count;
    if (result == GSF_OK) result = gsf_splat_load_train_views(ctx, &scene, train, count, &views);
    if (result == GSF_OK) result = gsf_splat_make_initial_splats(ctx, &scene, train, count, NULL, &start, NULL);
    gsf_fix_desc desc = gsf_splat_resolve_few_view_desc(&scene, count, GSF_QUALITY_EXACT);
    desc.trajectory = seed / 16 % 2 ? GSF_TRAJ_REFERENCE : GSF_TRAJ_SPREAD; // frames far from the photos, and near them
    desc.train.iterations = d->fit + (p->own ? 121 : 101); // a fifth of the last round's step, as in the loop
    desc.train.seed = seed;
    desc.first_round = d->fit / 3;
    desc.last_round = d->fit;
    desc.windows = count < DATA_WINDOWS ? (int32_t)count : DATA_WINDOWS;
    desc.window_frames = DATA_WINDOW;
    if (result == GSF_OK) result = gsf_splat_make_fixer(ctx, &desc, views, count, &start, &restorer, &fixer);
    while (result == GSF_OK && now.stage != GSF_FIX_DONE &&
           (p->own || !(now.stage == GSF_FIX_RESTORE && now.round == now.rounds && now.window == now.windows)))
        result = gsf_splat_step_fixer(ctx, fixer, &now);
    if (result == GSF_OK && p->own) result = data_finish(ctx, fixer, &scene, train, count, p);
    gsf_splat_destroy_fixer(ctx, fixer);
    gsf_splat_destroy(ctx, &start);
    gsf_free(ctx, views);
    gsf_splat_destroy_scene(ctx, &scene);
    return result;
}

// Makes the scene of a seed: DIR/scenes/SEED and then the file `path`.
static gsf_result make_data(gsf_context* ctx, const data_desc* d, uint64_t seed, const char* path) {
    const make_scene_options o = data_options(d, seed);
    char folder[1024];
    world s;
    data_probe p;
    memset(&s, 0, sizeof s);
    memset(&p, 0, sizeof p);
    snprintf(folder, sizeof folder, "%s/scenes/%llu", d->dir, (unsigned long long)seed);
    if (!make_folder(d->dir, "") || !make_folder(d->dir, "/scenes") || make_scene(ctx, &o, folder) != 0)
        return gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot make the scene", folder);
    p.s = &s;
    const double help = gsf_draw_uniform(seed, 1, 4);
    p.help = help < 0.5 ? 0.0f : help < 0.75 ? 0.5f : 1.0f;
    p.own = help < 0.5 ? d->own : NULL;
    gsf_result result = start_world(ctx, &s, &o) ? GSF_OK : gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: no scene", folder);
    if (result == GSF_OK) result = data_run(ctx, d, folder, &o, &p);
    gsf_nn_tensor frames;
    memset(&frames, 0, sizeof frames);
    frames.name = "frames";
    frames.data = p.bytes;
    frames.dtype = GSF_NN_U8;
    frames.rank = 4;
    frames.shape[0] = (int64_t)p.count;
    frames.shape[1] = p.height;
    frames.shape[2] = p.width;
    frames.shape[3] = DATA_PIXEL;
    frames.count = frames.shape[0] * frames.shape[1] * frames.shape[2] * frames.shape[3];
    if (result == GSF_OK) result = gsf_nn_save_tensors(ctx, path, &frames, 1);
    gsf_free(ctx, p.bytes);
    end_world(&s);
    return result;
}

#endif // MINI_DATA_H
