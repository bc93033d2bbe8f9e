// gsfix_dataset.c - the command dataset: sequences of artifact frames and the photos they should look like
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <limits.h>
#ifdef _WIN32
#include "gsfix_windows.h"
#endif
#include <math.h>

/* Each scene is a task with a folder of its own. K is a number of reference views, KIND is lr for splats trained on these views
   only, and the name of the perturbation for perturbed ones:
       OUT/SCENE/KIND/K/train_K/frame_00001_ref.png, frame_00002.png ...   artifact frames; _ref: a reference's camera
       OUT/SCENE/KIND/K/depth/frame_00001.npy                              their depth (float32, 0 = nothing there)
       OUT/SCENE/KIND/K/alpha/frame_00001.png                              their opacity
       OUT/SCENE/KIND/K/captions.json                                      the caption, a JSON string
       OUT/SCENE/nerfstudio/images_4/frame_00001.png                       the photos; frames are numbered as in the capture
       OUT/SCENE/sequences/KIND_K_00.json, KIND_K_00_cameras.json          manifest and cameras of each sequence
       OUT/SCENE/manifest.json                                             settings, sequences; written last
       OUT/SCENE/checkpoint                                                only while the scene is at work
       OUT/scenes.txt, OUT/dataset.json                                    all scenes
   train_K, captions.json, images_4 and scenes.txt are laid out as in DL3DV-Res: OUT serves the release's evaluation script
   both as --base_folder and as --ref_folders. Its reader takes the frames between two consecutive references as a sample of
   49 frames, which is exact when references are 48 frames apart, as they are here by default; at a distance of 49 it takes
   50 frames and fails.

   A scene's splats are trained one model after the other (for each K, then the clean one). Sequences of finished models are
   not rendered again when a run is resumed: they are finished if their manifest and all files that it lists are there,
   unchanged. The checkpoint holds the model in training. */

// ---- kinds and settings ------------------------------------------------------------

enum { KIND_SPARSE, KIND_PRUNE, KIND_SCALE, KIND_ROTATE, KIND_JITTER, KIND_COLOR, KIND_OPACITY, KIND_COUNT };

// The strengths of the perturbations: a share (prune), else the sigma of normal noise on log-scales, on the components of unit
// quaternions, on positions (in units of the scene's extent), on colours and on opacities (both from 0 to 1).
static const struct { const char *name, *folder; double strength; } kinds[KIND_COUNT] = {
    {"sparse", "lr", 0.0},       {"prune", "prune", 0.5},   {"scale", "scale", 0.5},     {"rotate", "rotate", 0.5},
    {"jitter", "jitter", 0.002}, {"color", "color", 0.05}, {"opacity", "opacity", 0.05}};

enum { MAX_VIEW_COUNTS = 16, BATCH = 8, STREAM_PERTURB = 0x70657274 };

struct gsfix_dataset_plan { // for all scenes
    int kinds;                  // bits of KIND_...
    int views[MAX_VIEW_COUNTS]; // values of K
    int view_counts, frames;
    const char* caption;
    gsfix_setup sparse, clean;
    gsf_buffer settings;        // JSON object without the closing brace: what determines the result, apart from the scene
    char** names;
};
typedef struct gsfix_dataset_plan dataset_plan;

static int parse_kinds(gsfix_app* app, dataset_plan* plan) {
    const char* text = app->o.kinds ? app->o.kinds : "sparse";
    for (const char* p = text;; p++) {
        const size_t n = strcspn(p, ",");
        int k = 0;
        while (k < KIND_COUNT && !(strlen(kinds[k].name) == n && strncmp(kinds[k].name, p, n) == 0)) k++;
        if (n == 3 && strncmp(p, "all", 3) == 0) plan->kinds = (1 << KIND_COUNT) - 1;
        else if (k == KIND_COUNT) return gsfix_misused(app, "--kinds %s: no kind \"%.*s\"", text, (int)n, p);
        else plan->kinds |= 1 << k;
        p += n;
        if (!*p) return 0;
    }
}

int gsfix_parse_views(gsfix_app* app, const char* text, int views[MAX_VIEW_COUNTS], int* count) {
    *count = 0;
    for (const char* p = text;; p++) {
        char* end;
        const long k = strtol(p, &end, 10);
        int again = 0;
        if (end == p || (*end && *end != ',') || k < 2 || k > 1000)
            return gsfix_misused(app, "--views %s: expected numbers of at least 2, separated by commas", text);
        for (int i = 0; i < *count; i++) again |= views[i] == k;
        if (again || *count == MAX_VIEW_COUNTS)
            return gsfix_misused(app, "--views %s: %s", text, again ? "a number stands there twice" : "too many");
        views[(*count)++] = (int)k;
        p = end;
        if (!*p) return 0;
    }
}

static void write_settings(gsfix_app* app, dataset_plan* plan) {
    gsf_context* ctx = &app->ctx;
    const gsfix_options* o = &app->o;
    gsf_buffer *t = &plan->settings, list = {0};
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "version", GSF_VERSION);
    for (int k = 0; k < KIND_COUNT; k++)
        if (plan->kinds >> k & 1) gsf_append_text(ctx, &list, "%s%s", list.size ? "," : "", kinds[k].name);
    gsfix_json_text(ctx, t, "kinds", list.data);
    if (list.failed) t->failed = 1;
    gsf_destroy_buffer(ctx, &list);
    gsfix_json_begin(ctx, t, "views", '[');
    for (int i = 0; i < plan->view_counts; i++) gsfix_json_number(ctx, t, NULL, plan->views[i]);
    gsfix_json_end(ctx, t, ']');
    gsfix_json_number(ctx, t, "frames", plan->frames);
    gsfix_json_text(ctx, t, "seed", gsfix_pathf("%llu", (unsigned long long)o->seed).s);
    gsfix_json_number(ctx, t, "iterations", plan->sparse.fix.train.iterations);
    if (plan->kinds & ~1) gsfix_json_number(ctx, t, "clean_iterations", plan->clean.fix.train.iterations);
    gsfix_json_text(ctx, t, "init", o->init);
    gsfix_json_text(ctx, t, "regularize", o->regularize);
    gsfix_json_text(ctx, t, "quality", gsfix_find_quality(o->quality)->name);
    gsfix_json_text(ctx, t, "set", o->settings ? o->settings : "");
    gsfix_json_number(ctx, t, "factor", o->factor ? o->factor : 1);
    gsfix_json_number(ctx, t, "max_size", o->max_size);
    gsfix_json_text(ctx, t, "caption", plan->caption);
}

static int resolve_plan(gsfix_app* app, dataset_plan* plan) { // 0 or an exit code
    int code = parse_kinds(app, plan);
    if (!code) code = gsfix_parse_views(app, app->o.views ? app->o.views : "3", plan->views, &plan->view_counts);
    if (code) return code;
    plan->frames = app->o.frames ? app->o.frames : 49;
    plan->caption = app->o.caption ? app->o.caption : "";
    app->o.caption = NULL; // else taken for that of a restorer
    if (plan->frames == 50) gsfix_note(app, "note: the release's reader fails on references that are 49 frames apart");
    if (!app->o.regularize) app->o.regularize = "off";
    if (!app->o.init) app->o.init = "tracks";
    code = gsfix_resolve_setup(app, &plan->sparse);
    if (code) return code;
    plan->clean = plan->sparse;
    plan->clean.initial.kind = GSF_INITIAL_ALL;
    plan->clean.fix.train.iterations = app->o.clean_iterations ? app->o.clean_iterations : 3000;
    write_settings(app, plan);
    return 0;
}

// ---- a scene -----------------------------------------------------------------------

typedef struct track { // the frames for one K
    uint32_t *frames, *refs; // views of the scene; indices into frames
    size_t frame_count, ref_count;
} track;

typedef struct scene_run {
    gsfix_app* app;
    gsf_context* ctx;
    const dataset_plan* plan;
    const char* name;
    gsf_scene scene;
    track tracks[MAX_VIEW_COUNTS];
    uint8_t* used;        // views that are a frame
    gsf_buffer settings;  // those of the plan, and the scene's digest
    float near_plane;
    int resuming;
    int32_t saved_model;  // of the checkpoint
    void* saved;          // its chunks, or NULL
    size_t saved_size;
    double checkpoint_time;
    int model, model_count; // in training
    int32_t iteration;      // of the trainer
    size_t to_render, rendered; // frames of the model
    int32_t saved_iteration;
    gsf_trainer* trainer;
    gsf_rasterizer* rasterizer;
} scene_run;

static gsfix_path frame_stem(uint32_t view) { return gsfix_pathf("frame_%05u", (unsigned)view + 1); }

static gsfix_path sequence_file(const scene_run* run, int kind, int k, size_t s, const char* ending) {
    return gsfix_pathf("sequences/%s_%d_%02zu%s.json", kinds[kind].folder, run->plan->views[k], s, ending);
}

static gsfix_path frame_file(const scene_run* run, int kind, int k, size_t frame, int file) {
    const track* t = &run->tracks[k];
    const int views = run->plan->views[k];
    const gsfix_path stem = frame_stem(t->frames[frame]);
    const char* folder = kinds[kind].folder;
    int is_ref = 0;
    for (size_t r = 0; r < t->ref_count; r++) is_ref |= t->refs[r] == frame;
    if (file == GSFIX_ARTIFACT)
        return gsfix_pathf("%s/%d/train_%d/%s%s.png", folder, views, views, stem.s, is_ref ? "_ref" : "");
    if (file == GSFIX_DEPTH) return gsfix_pathf("%s/%d/depth/%s.npy", folder, views, stem.s);
    if (file == GSFIX_ALPHA) return gsfix_pathf("%s/%d/alpha/%s.png", folder, views, stem.s);
    return gsfix_pathf("nerfstudio/images_4/%s.png", stem.s);
}

static gsfix_path at_out(const scene_run* run, gsfix_path name) { return gsfix_pathf("%s/%s", run->app->o.out, name.s); }

// Chooses frames and references: both evenly over what they are chosen from, first and last included.
static gsf_result make_track(scene_run* run, int k) {
    track* t = &run->tracks[k];
    const size_t photos = run->scene.view_count, views = (size_t)run->plan->views[k];
    const size_t wanted = (views - 1) * (size_t)(run->plan->frames - 1) + 1, count = photos < wanted ? photos : wanted;
    if (photos < views)
        return gsf_fail(run->ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: only %zu photos, but --views %zu", run->scene.folder,
                        photos, views);
    if (k == 0 && photos < 49)
        gsfix_note(run->app, "note: %zu photos; the release's reader skips scenes with fewer than 49", photos);
    t->frames = (uint32_t*)gsf_alloc(run->ctx, photos + 1, sizeof *t->frames);
    t->refs = (uint32_t*)gsf_alloc(run->ctx, photos + 1, sizeof *t->refs);
    if (!t->frames || !t->refs) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_splat_split_views(photos, 0, count, t->frames, &t->frame_count, NULL, NULL);
    gsf_splat_split_views(count, 0, views, t->refs, &t->ref_count, NULL, NULL);
    for (size_t i = 0; i < count; i++) run->used[t->frames[i]] = 1;
    return GSF_OK;
}

// The cameras' files, which gsfix_load_scene has read, and the sizes of the photos.
static gsf_result digest_scene(scene_run* run) {
    gsf_context* ctx = run->ctx;
    gsf_buffer text = {0};
    size_t count = 0;
    const gsfix_read_file* reads = gsfix_end_inputs(run->app, &count);
    for (size_t i = 0; i < count; i++)
        gsf_append_text(ctx, &text, "%016llx %llu\n", (unsigned long long)reads[i].digest, (unsigned long long)reads[i].size);
    for (size_t i = 0; i < run->scene.view_count; i++)
        gsf_append_text(ctx, &text, "%s %llu\n", run->scene.views[i].name,
                        (unsigned long long)gsfix_file_size(gsf_splat_get_view_path(&run->scene, i)));
    gsf_append_bytes(ctx, &run->settings, run->plan->settings.data, run->plan->settings.size);
    const uint64_t digest = gsfix_digest(text.data ? text.data : "", text.size);
    gsfix_json_text(ctx, &run->settings, "scene", gsfix_pathf("%016llx", (unsigned long long)digest).s);
    gsfix_json_end(ctx, &run->settings, '}');
    const int failed = text.failed || run->settings.failed || run->plan->settings.failed;
    gsf_destroy_buffer(ctx, &text);
    return failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

static gsf_result open_scene_out(scene_run* run) {
    gsfix_app* app = run->app;
    gsf_result result = gsfix_claim(app, "checkpoint");
    if (result == GSF_OK) result = gsfix_claim(app, "manifest.json");
    if (result == GSF_OK) result = gsfix_claim(app, "nerfstudio/images_4/frame_*.png");
    for (int k = 0; k < run->plan->view_counts; k++) {
        const int views = run->plan->views[k];
        for (int kind = 0; kind < KIND_COUNT && result == GSF_OK; kind++) {
            const char* folder = kinds[kind].folder;
            if (!(run->plan->kinds >> kind & 1)) continue;
            result = gsfix_claim(app, "%s/%d/train_%d/frame_*.png", folder, views, views);
            if (result == GSF_OK) result = gsfix_claim(app, "%s/%d/depth/frame_*.npy", folder, views);
            if (result == GSF_OK) result = gsfix_claim(app, "%s/%d/alpha/frame_*.png", folder, views);
            if (result == GSF_OK) result = gsfix_claim(app, "%s/%d/captions.json", folder, views);
            if (result == GSF_OK) result = gsfix_claim(app, "sequences/%s_%d_*.json", folder, views);
        }
    }
    return result == GSF_OK ? gsfix_open_out(app) : result;
}

// ---- checkpoint --------------------------------------------------------------------

static int read_whole(const gsf_json* json, const gsf_json_value* object, const char* key, double least, double most,
                      int32_t* out) {
    const gsf_json_value* v = gsf_find_json_member(json, object, key);
    if (!v || v->type != GSF_JSON_NUMBER || !(v->number >= least && v->number <= most) || v->number != floor(v->number))
        return 0;
    *out = (int32_t)v->number;
    return 1;
}

static gsf_result save_state(scene_run* run) {
    gsf_context* ctx = run->ctx;
    gsf_buffer chunks = {0}, text = {0};
    gsfix_json_begin(ctx, &text, NULL, '{');
    gsfix_json_number(ctx, &text, "model", run->trainer ? run->model : -1);
    gsfix_json_number(ctx, &text, "iteration", run->iteration);
    gsfix_json_begin(ctx, &text, "settings", '{');
    text.size--; // drop the brace; the object itself is appended
    gsf_append_bytes(ctx, &text, run->settings.data, run->settings.size);
    gsfix_json_end(ctx, &text, '}');
    if (run->trainer) gsf_splat_format_trainer(ctx, run->trainer, &chunks);
    gsf_append_chunk(ctx, &chunks, "GDAT", text.data, text.size);
    gsf_append_last_chunk(ctx, &chunks);
    gsf_result result = text.failed || chunks.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    if (result == GSF_OK)
        result = gsf_write_file(ctx, gsfix_pathf("%s/checkpoint", run->app->o.out).s, chunks.data, chunks.size);
    gsf_destroy_buffer(ctx, &chunks);
    gsf_destroy_buffer(ctx, &text);
    run->checkpoint_time = gsfix_now();
    return result;
}

static gsf_result load_state(scene_run* run) {
    gsf_context* ctx = run->ctx;
    const gsfix_path path = gsfix_pathf("%s/checkpoint", run->app->o.out);
    gsf_chunk chunk;
    gsf_json json = {0};
    gsf_result result = gsf_read_file(ctx, path.s, &run->saved, &run->saved_size);
    if (result == GSF_OK) result = gsf_check_chunks(ctx, path.s, run->saved, run->saved_size);
    if (result == GSF_OK && !gsf_find_chunk(run->saved, run->saved_size, "GDAT", &chunk))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not a checkpoint of gsfix dataset", path.s);
    if (result == GSF_OK) result = gsf_parse_json(ctx, path.s, (const char*)chunk.data, chunk.size, &json);
    const gsf_json_value* root = result == GSF_OK ? json.values : NULL;
    if (root)
        result = gsfix_compare_settings(ctx, path.s, &run->settings, &json, gsf_find_json_member(&json, root, "settings"));
    if (result == GSF_OK && (!read_whole(&json, root, "model", -1, 1000, &run->saved_model) ||
                             !read_whole(&json, root, "iteration", 0, INT32_MAX, &run->saved_iteration)))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid model or number of steps", path.s);
    gsf_destroy_json(ctx, &json);
    return result;
}

// Decides what to do with what an earlier run has left in the folder.
static gsf_result meet_earlier(scene_run* run) {
    gsfix_app* app = run->app;
    const int begun = gsfix_has_output(app, "checkpoint"), done = gsfix_has_output(app, "manifest.json");
    run->saved_model = -1;
    if ((begun || done) && !app->o.restart) {
        if (!app->o.resume)
            return gsf_fail(run->ctx, GSF_ERROR_IO, "%s holds %s: --resume goes on, --restart begins anew", app->o.out,
                            begun ? "a run that was interrupted" : "the results of a run");
        if (done && !begun)
            return gsf_fail(run->ctx, GSF_ERROR_INVALID_ARGUMENT,
                            "%s/manifest.json: made with other settings or another version (--restart begins anew)",
                            app->o.out);
        run->resuming = 1;
        return load_state(run);
    }
    gsf_result result = gsfix_remove_output(app, "checkpoint");
    if (result == GSF_OK) result = gsfix_remove_output(app, "manifest.json");
    if (result == GSF_OK) result = gsfix_remove_stale(app);
    return result == GSF_OK ? save_state(run) : result; // says what the files to come are made with
}

// ---- training ----------------------------------------------------------------------

static gsf_result stop(scene_run* run, const char* where) { // keeps the state and says where it was left
    gsf_clear_cancel(run->ctx);
    const gsf_result result = run->trainer ? save_state(run) : GSF_OK;
    if (result != GSF_OK) return result;
    return gsf_fail(run->ctx, GSF_ERROR_CANCELLED, "stopped %s of %s; --resume goes on", where, run->name);
}

// A model is trained in nine tenths of its part of the bar and rendered in the rest.
static void show(const scene_run* run, int rendering, double done, double total) {
    const double share = rendering ? 0.9 + 0.1 * done / total : 0.9 * done / total;
    gsfix_progress(run->app, run->model + share, run->model_count, "%s: model %d of %d, %s %.0f of %.0f", run->name,
                   run->model + 1, run->model_count, rendering ? "frame" : "step", done, total);
}

static gsf_result train(scene_run* run, int32_t steps) {
    const int every = run->app->o.checkpoint_every;
    gsf_train_stats stats;
    while (run->iteration < steps) {
        gsf_result result = gsf_splat_step_trainer(run->ctx, run->trainer, &stats);
        if (result == GSF_OK) run->iteration = stats.iteration;
        if (result == GSF_ERROR_CANCELLED || (result == GSF_OK && gsf_is_cancelled(run->ctx)))
            return stop(run, gsfix_pathf("at step %d of %d of model %d", (int)run->iteration, (int)steps, run->model + 1).s);
        if (result != GSF_OK) return result;
        const int due = every ? run->iteration % every == 0 : gsfix_now() - run->checkpoint_time > 60.0;
        if (due || run->iteration == steps) result = save_state(run);
        if (result != GSF_OK) return result;
        show(run, 0, run->iteration, steps);
    }
    return GSF_OK;
}

static void drop_photo(scene_run* run, size_t view) {
    gsf_destroy_image(run->ctx, &run->scene.views[view].image);
    gsf_destroy_image(run->ctx, &run->scene.views[view].weight);
}

static gsf_result start_trainer(scene_run* run, const gsfix_setup* setup, const uint32_t* views, size_t count) {
    gsf_context* ctx = run->ctx;
    gsf_train_view* photos = NULL;
    gsf_splats initial = {0};
    gsf_train_desc desc = setup->fix.train;
    gsf_initial_desc start = setup->initial;
    desc.render.near_plane = run->near_plane;
    gsfix_settle_train(&desc, start.kind, count);
    if (start.kind == GSF_INITIAL_ALL && !run->scene.point_count) start.kind = GSF_INITIAL_RANDOM;
    run->iteration = 0;
    gsf_result result = gsf_splat_load_train_views(ctx, &run->scene, views, count, &photos);
    if (result == GSF_OK) result = gsf_splat_make_initial_splats(ctx, &run->scene, views, count, &start, &initial, NULL);
    if (result == GSF_OK) result = gsf_splat_make_trainer(ctx, &desc, photos, count, &initial, &run->trainer);
    for (size_t i = 0; i < run->scene.view_count; i++) drop_photo(run, i); // the trainer has copies
    gsf_splat_destroy(ctx, &initial);
    gsf_free(ctx, photos);
    if (result != GSF_OK || !run->saved || run->saved_model != run->model) return result;
    run->iteration = run->saved_iteration;
    return gsf_splat_parse_trainer(ctx, run->trainer, gsfix_pathf("%s/checkpoint", run->app->o.out).s, run->saved,
                                   run->saved_size);
}

// k: the number of references, or -1: all photos.
static gsf_result train_model(scene_run* run, int k) {
    const gsfix_setup* setup = k < 0 ? &run->plan->clean : &run->plan->sparse;
    const size_t count = k < 0 ? run->scene.view_count : run->tracks[k].ref_count;
    uint32_t* views = (uint32_t*)gsf_alloc(run->ctx, count + 1, sizeof *views);
    if (!views) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) views[i] = k < 0 ? (uint32_t)i : run->tracks[k].frames[run->tracks[k].refs[i]];
    gsf_result result = start_trainer(run, setup, views, count);
    gsf_free(run->ctx, views);
    run->checkpoint_time = gsfix_now();
    if (result == GSF_OK) result = train(run, setup->fix.train.iterations);
    return result;
}

// ---- perturbation ------------------------------------------------------------------

static double noise(uint64_t seed, uint64_t stream, uint32_t id, int component) {
    return gsf_draw_normal(seed, stream, (uint64_t)id * 4 + (uint64_t)component);
}

static void perturb_one(gsf_splats* s, size_t i, int kind, double strength, double extent, uint64_t seed, uint64_t stream) {
    const size_t coefficients = (size_t)gsf_splat_count_sh(s->sh_degree);
    float *scale = s->log_scales + 3 * i, *quat = s->quats + 4 * i, *mean = s->means + 3 * i;
    float *color = s->sh + 3 * coefficients * i, *logit = s->opacity_logits + i;
    double length = 0.0;
    for (int c = 0; c < 4; c++) length += (double)quat[c] * (double)quat[c];
    length = sqrt(length);
    for (int c = 0; c < 4 && kind == KIND_ROTATE; c++)
        quat[c] = (float)((double)quat[c] + (length > 0.0 ? length : 1.0) * strength * noise(seed, stream, s->ids[i], c));
    for (int c = 0; c < 3; c++) {
        const double z = strength * noise(seed, stream, s->ids[i], c);
        if (kind == KIND_SCALE) scale[c] = (float)((double)scale[c] + z);
        if (kind == KIND_JITTER) mean[c] = (float)((double)mean[c] + extent * z);
        if (kind == KIND_COLOR) color[c] = (float)((double)color[c] + z / 0.28209479177387814); // of SH band 0
    }
    if (kind == KIND_OPACITY) {
        double opacity = 1.0 / (1.0 + exp(-(double)*logit)) + strength * noise(seed, stream, s->ids[i], 0);
        opacity = opacity < 0.001 ? 0.001 : opacity > 0.999 ? 0.999 : opacity;
        *logit = (float)log(opacity / (1.0 - opacity));
    }
}

static gsf_result perturb(scene_run* run, const gsf_splats* clean, int kind, int k, gsf_splats* out) {
    const uint64_t seed = run->app->o.seed;
    const uint64_t stream = (uint64_t)STREAM_PERTURB << 32 | (uint64_t)kind << 16 | (uint64_t)run->plan->views[k];
    const double extent = gsf_splat_get_trainer_desc(run->trainer).extent, strength = kinds[kind].strength;
    const size_t row = 3 * (size_t)gsf_splat_count_sh(clean->sh_degree);
    size_t n = 0;
    gsf_result result = gsf_splat_make(run->ctx, clean->count, clean->sh_degree, out);
    if (result != GSF_OK) return result;
    memcpy(out->origin, clean->origin, sizeof out->origin);
    memcpy(out->background, clean->background, sizeof out->background);
    for (size_t i = 0; i < clean->count; i++) {
        if (kind == KIND_PRUNE && gsf_draw_uniform(seed, stream, clean->ids[i]) < strength) continue;
        memcpy(out->means + 3 * n, clean->means + 3 * i, 3 * sizeof(float));
        memcpy(out->log_scales + 3 * n, clean->log_scales + 3 * i, 3 * sizeof(float));
        memcpy(out->quats + 4 * n, clean->quats + 4 * i, 4 * sizeof(float));
        memcpy(out->sh + row * n, clean->sh + row * i, row * sizeof(float));
        out->opacity_logits[n] = clean->opacity_logits[i];
        out->ids[n] = clean->ids[i];
        perturb_one(out, n++, kind, strength, extent, seed, stream);
    }
    out->count = n;
    return GSF_OK;
}

// ---- frames ------------------------------------------------------------------------

static gsf_result write_photos(scene_run* run) {
    gsf_context* ctx = run->ctx;
    const gsf_camera* first = &run->scene.views[0].camera;
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < run->scene.view_count && result == GSF_OK;) {
        gsfix_path paths[BATCH];
        gsf_image photos[BATCH];
        size_t views[BATCH], n = 0;
        for (; i < run->scene.view_count && n < BATCH && result == GSF_OK; i++) {
            const gsf_scene_view* view = &run->scene.views[i];
            const gsfix_path name = gsfix_pathf("nerfstudio/images_4/%s.png", frame_stem((uint32_t)i).s);
            if (!run->used[i]) continue;
            if (view->camera.width != first->width || view->camera.height != first->height)
                return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %d x %d, but the first photo is %d x %d", view->name,
                                (int)view->camera.width, (int)view->camera.height, (int)first->width, (int)first->height);
            if (run->resuming && gsfix_has_output(run->app, name.s)) continue;
            if (gsf_is_cancelled(ctx)) return stop(run, "while the photos were written");
            result = gsf_splat_load_view_image(ctx, &run->scene, i);
            if (result != GSF_OK) break;
            paths[n] = at_out(run, name);
            photos[n] = view->image;
            views[n++] = i;
        }
        if (result == GSF_OK) result = gsfix_save_images(ctx, paths, photos, n);
        for (size_t b = 0; b < n; b++) drop_photo(run, views[b]);
    }
    return result;
}

typedef struct frame_batch {
    gsfix_path paths[2 * BATCH];
    gsf_image images[2 * BATCH]; // artifact frames and opacity
    size_t count;                // of frames
} frame_batch;

static gsf_result render_frame(scene_run* run, const gsf_splats* splats, int kind, int k, size_t frame, frame_batch* b,
                               double* psnr) {
    gsf_context* ctx = run->ctx;
    const size_t view = run->tracks[k].frames[frame], at = 2 * b->count++;
    const gsf_camera* camera = &run->scene.views[view].camera;
    gsf_render_desc desc = run->plan->sparse.fix.train.render;
    gsf_render_output out = {0};
    gsf_image* color = &b->images[at];
    desc.near_plane = run->near_plane;
    memcpy(desc.background, splats->background, sizeof desc.background);
    b->paths[at] = at_out(run, frame_file(run, kind, k, frame, GSFIX_ARTIFACT));
    b->paths[at + 1] = at_out(run, frame_file(run, kind, k, frame, GSFIX_ALPHA));
    gsf_result result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, color);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &b->images[at + 1]);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &out.depth);
    out.color = *color;
    out.alpha = b->images[at + 1];
    if (result == GSF_OK) result = gsf_splat_render(ctx, run->rasterizer, splats, camera, &desc, &out);
    if (result == GSF_OK) {
        gsfix_clamp(color);
        gsfix_clamp(&out.alpha);
        result = gsfix_save_npy(ctx, at_out(run, frame_file(run, kind, k, frame, GSFIX_DEPTH)).s, &out.depth);
    }
    if (result == GSF_OK) result = gsf_splat_load_view_image(ctx, &run->scene, view);
    if (result == GSF_OK) result = gsf_measure_image(ctx, GSF_METRIC_PSNR, color, &run->scene.views[view].image, NULL, psnr);
    drop_photo(run, view);
    gsf_destroy_image(ctx, &out.depth);
    return result;
}

// ---- manifests ---------------------------------------------------------------------

static const char* const file_keys[GSFIX_FRAME_FILES] = {"artifact", "clean", "depth", "alpha"};

static gsf_result write_text(scene_run* run, gsfix_path name, gsf_buffer* text) { // destroys text
    gsf_append_bytes(run->ctx, text, "\n", 1);
    const gsf_result result = text->failed ? GSF_ERROR_OUT_OF_MEMORY
                                           : gsf_write_file(run->ctx, at_out(run, name).s, text->data, text->size);
    gsf_destroy_buffer(run->ctx, text);
    return result;
}

static gsf_result missing(scene_run* run, const char* name) {
    return gsf_fail(run->ctx, GSF_ERROR_IO, "%s/%s: has been removed or changed while gsfix was at work", run->app->o.out,
                    name);
}

static gsf_result write_sequence_frame(scene_run* run, gsf_buffer* t, int kind, int k, size_t frame, int is_ref, double psnr) {
    gsf_context* ctx = run->ctx;
    const size_t view = run->tracks[k].frames[frame];
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "name", frame_stem((uint32_t)view).s);
    gsfix_json_text(ctx, t, "photo", run->scene.views[view].name);
    gsfix_json_bool(ctx, t, "reference", is_ref);
    gsfix_json_number(ctx, t, "psnr", psnr);
    for (int f = 0; f < GSFIX_FRAME_FILES; f++)
        gsfix_json_text(ctx, t, file_keys[f], frame_file(run, kind, k, frame, f).s);
    gsfix_json_begin(ctx, t, "digests", '[');
    for (int f = 0; f < GSFIX_FRAME_FILES; f++) {
        const gsfix_path name = frame_file(run, kind, k, frame, f);
        uint64_t size, digest;
        if (!gsfix_query_output(run->app, name.s, &size, &digest)) return missing(run, name.s);
        gsfix_json_text(ctx, t, NULL, gsfix_pathf("%016llx", (unsigned long long)digest).s);
    }
    gsfix_json_end(ctx, t, ']');
    gsfix_json_end(ctx, t, '}');
    return GSF_OK;
}

static gsf_result write_sequence(scene_run* run, const gsf_splats* splats, int kind, int k, size_t s, const double* psnr) {
    gsf_context* ctx = run->ctx;
    const track* t = &run->tracks[k];
    const gsf_camera* first = &run->scene.views[0].camera;
    const size_t begin = t->refs[s], end = t->refs[s + 1];
    const gsfix_setup* setup = kind == KIND_SPARSE ? &run->plan->sparse : &run->plan->clean;
    const gsfix_path cameras = sequence_file(run, kind, k, s, "_cameras");
    gsf_buffer out = {0};
    gsf_result result = GSF_OK;
    gsfix_json_begin(ctx, &out, NULL, '{');
    gsfix_json_text(ctx, &out, "format", "gsfixer sequence 1");
    gsfix_json_text(ctx, &out, "version", GSF_VERSION);
    gsfix_json_text(ctx, &out, "scene", run->name);
    gsfix_json_text(ctx, &out, "kind", kinds[kind].name);
    gsfix_json_number(ctx, &out, "strength", kinds[kind].strength);
    gsfix_json_number(ctx, &out, "views", run->plan->views[k]);
    gsfix_json_number(ctx, &out, "sequence", (double)s);
    gsfix_json_text(ctx, &out, "seed", gsfix_pathf("%llu", (unsigned long long)run->app->o.seed).s);
    gsfix_json_number(ctx, &out, "iterations", setup->fix.train.iterations);
    gsfix_json_number(ctx, &out, "splats", (double)splats->count);
    gsfix_json_text(ctx, &out, "isa", gsf_describe_cpu_level(ctx->cpu_level));
    gsfix_json_number(ctx, &out, "width", first->width);
    gsfix_json_number(ctx, &out, "height", first->height);
    gsfix_json_number(ctx, &out, "near_plane", run->near_plane);
    gsfix_json_text(ctx, &out, "caption", run->plan->caption);
    gsfix_json_text(ctx, &out, "cameras", cameras.s);
    gsfix_json_begin(ctx, &out, "frames", '[');
    for (size_t i = begin; i <= end && result == GSF_OK; i++)
        result = write_sequence_frame(run, &out, kind, k, i, i == begin || i == end, psnr[i - begin]);
    gsfix_json_end(ctx, &out, ']');
    gsfix_json_end(ctx, &out, '}');
    if (result == GSF_OK) return write_text(run, sequence_file(run, kind, k, s, ""), &out);
    gsf_destroy_buffer(ctx, &out);
    return result;
}

static gsf_result write_sequence_cameras(scene_run* run, int kind, int k, size_t s) {
    const track* t = &run->tracks[k];
    const size_t begin = t->refs[s], count = t->refs[s + 1] - begin + 1;
    gsf_camera* cameras = (gsf_camera*)gsf_alloc(run->ctx, count, sizeof *cameras);
    gsfix_path* stems = (gsfix_path*)gsf_alloc(run->ctx, count, sizeof *stems);
    const char** names = (const char**)gsf_alloc(run->ctx, count, sizeof *names);
    gsf_result result = cameras && stems && names ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        cameras[i] = run->scene.views[t->frames[begin + i]].camera;
        stems[i] = frame_stem(t->frames[begin + i]);
        names[i] = stems[i].s;
    }
    if (result == GSF_OK)
        result = gsf_save_cameras(run->ctx, at_out(run, sequence_file(run, kind, k, s, "_cameras")).s, cameras, names, count);
    gsf_free(run->ctx, cameras);
    gsf_free(run->ctx, stems);
    gsf_free(run->ctx, (void*)names);
    return result;
}

// ---- sequences ---------------------------------------------------------------------

static gsf_result render_sequence(scene_run* run, const gsf_splats* splats, int kind, int k, size_t s) {
    gsf_context* ctx = run->ctx;
    const track* t = &run->tracks[k];
    const size_t begin = t->refs[s], end = t->refs[s + 1];
    double* psnr = (double*)gsf_alloc(ctx, end - begin + 1, sizeof *psnr);
    gsf_result result = psnr ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = begin; i <= end && result == GSF_OK;) {
        frame_batch batch;
        memset(&batch, 0, sizeof batch);
        for (; i <= end && batch.count < BATCH && result == GSF_OK; i++) {
            result = render_frame(run, splats, kind, k, i, &batch, psnr + (i - begin));
            if (gsf_is_cancelled(ctx)) result = stop(run, "while the frames were rendered");
            show(run, 1, (double)++run->rendered, (double)run->to_render);
        }
        if (result == GSF_OK) result = gsfix_save_images(ctx, batch.paths, batch.images, 2 * batch.count);
        for (size_t b = 0; b < 2 * batch.count; b++) gsf_destroy_image(ctx, &batch.images[b]);
    }
    if (result == GSF_OK) result = write_sequence_cameras(run, kind, k, s);
    if (result == GSF_OK) result = write_sequence(run, splats, kind, k, s, psnr);
    gsf_free(ctx, psnr);
    return result;
}

gsf_result gsfix_load_sequence(gsf_context* ctx, gsfix_path path, gsfix_sequence* out) {
    void* data = NULL;
    size_t size = 0;
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_read_file(ctx, path.s, &data, &size);
    if (result == GSF_OK) result = gsfix_parse_sequence(ctx, path.s, (const char*)data, size, out);
    gsf_free(ctx, data);
    return result;
}

// Is the sequence as an earlier run has left it when it was complete?
static int is_finished(scene_run* run, int kind, int k, size_t s) {
    const gsfix_path name = sequence_file(run, kind, k, s, "");
    gsfix_sequence sequence = {0};
    if (!run->resuming || !gsfix_has_output(run->app, name.s)) return 0;
    int finished = gsfix_has_output(run->app, sequence_file(run, kind, k, s, "_cameras").s) &&
                   gsfix_load_sequence(run->ctx, at_out(run, name), &sequence) == GSF_OK;
    for (size_t i = 0; finished && i < sequence.frame_count; i++)
        for (int f = 0; f < GSFIX_FRAME_FILES && finished; f++) {
            uint64_t size, digest;
            finished = gsfix_query_output(run->app, sequence.frames[i].files[f], &size, &digest) &&
                       digest == sequence.frames[i].digests[f];
        }
    gsfix_free_sequence(run->ctx, &sequence);
    run->ctx->error[0] = 0;
    return finished;
}

static gsf_result write_caption(scene_run* run, int kind, int k) {
    gsf_buffer text = {0};
    gsf_append_json_string(run->ctx, &text, run->plan->caption);
    return write_text(run, gsfix_pathf("%s/%d/captions.json", kinds[kind].folder, run->plan->views[k]), &text);
}

// The sequences of one kind and K from the model that has just been trained; without one, counts the frames that are missing.
static gsf_result render_track(scene_run* run, int kind, int k) {
    const gsf_splats* trained = run->trainer ? gsf_splat_get_trained(run->trainer) : NULL;
    gsf_splats perturbed = {0};
    gsf_result result = GSF_OK;
    if (trained && kind != KIND_SPARSE) result = perturb(run, trained, kind, k, &perturbed);
    if (trained && result == GSF_OK) result = write_caption(run, kind, k);
    for (size_t s = 0; s + 1 < run->tracks[k].ref_count && result == GSF_OK; s++) {
        if (is_finished(run, kind, k, s)) continue;
        if (!trained) run->to_render += run->tracks[k].refs[s + 1] - run->tracks[k].refs[s] + 1;
        if (trained) result = render_sequence(run, kind == KIND_SPARSE ? trained : &perturbed, kind, k, s);
    }
    gsf_splat_destroy(run->ctx, &perturbed);
    return result;
}

static gsf_result render_model(scene_run* run, int k) { // k: as for train_model
    gsf_result result = GSF_OK;
    if (k >= 0) return render_track(run, KIND_SPARSE, k);
    for (int kind = 1; kind < KIND_COUNT; kind++)
        for (int i = 0; i < run->plan->view_counts && result == GSF_OK; i++)
            if (run->plan->kinds >> kind & 1) result = render_track(run, kind, i);
    return result;
}

static gsf_result make_model(scene_run* run, int k) {
    run->to_render = run->rendered = 0;
    gsf_result result = render_model(run, k);
    if (result == GSF_OK && run->to_render) result = train_model(run, k);
    if (result == GSF_OK && run->to_render) result = render_model(run, k);
    gsf_splat_destroy_trainer(run->ctx, run->trainer);
    run->trainer = NULL;
    run->model++;
    return result;
}

// ---- reading manifests ---------------------------------------------------------------

static int is_plain(const char* text) { // no control characters, which would break a line
    for (const char* p = text; *p; p++)
        if ((unsigned char)*p < 0x20 || *p == 0x7f) return 0;
    return 1;
}

static const char* read_plain(const gsf_json* json, const gsf_json_value* object, const char* key) { // NULL: none
    const gsf_json_value* v = gsf_find_json_member(json, object, key);
    return v && v->type == GSF_JSON_STRING && strlen(v->string) == v->string_size && is_plain(v->string) ? v->string : NULL;
}

static const char* read_inner_path(const gsf_json* json, const gsf_json_value* object, const char* key) { // NULL: leads out
    const char* path = read_plain(json, object, key);
    if (!path || strlen(path) > 1000 || strchr(path, '\\')) return NULL;
    for (const char* p = path;; p += *p == '/') {
        const size_t n = strcspn(p, "/");
        if (n == 0 || (n == 1 && p[0] == '.') || (n == 2 && p[0] == '.' && p[1] == '.')) return NULL;
        p += n;
        if (!*p) return path;
    }
}

static int read_digest(const gsf_json_value* v, uint64_t* out) {
    if (!v || v->type != GSF_JSON_STRING || v->string_size != 16 || strspn(v->string, "0123456789abcdef") != 16) return 0;
    *out = strtoull(v->string, NULL, 16);
    return 1;
}

static int read_psnr(const gsf_json* json, const gsf_json_value* object, double* out) { // null: infinite
    const gsf_json_value* v = gsf_find_json_member(json, object, "psnr");
    if (!v || (v->type != GSF_JSON_NUMBER && v->type != GSF_JSON_NULL)) return 0;
    *out = v->type == GSF_JSON_NUMBER ? v->number : INFINITY;
    return 1;
}

static const gsf_json_value* read_list(const gsf_json* json, const char* format, const char* key, size_t least) {
    const char* is = read_plain(json, json->values, "format");
    const gsf_json_value* list = gsf_find_json_member(json, json->values, key);
    return is && strcmp(is, format) == 0 && list && list->type == GSF_JSON_ARRAY && list->count >= least ? list : NULL;
}

static int read_frame(const gsf_json* json, const gsf_json_value* v, gsfix_sequence_frame* out) {
    const gsf_json_value* reference = gsf_find_json_member(json, v, "reference");
    const gsf_json_value* digests = gsf_find_json_member(json, v, "digests");
    int ok = reference && (reference->type == GSF_JSON_TRUE || reference->type == GSF_JSON_FALSE) && digests &&
             digests->type == GSF_JSON_ARRAY && digests->count == GSFIX_FRAME_FILES && read_psnr(json, v, &out->psnr);
    out->reference = ok && reference->type == GSF_JSON_TRUE;
    out->name = read_inner_path(json, v, "name");
    out->photo = read_plain(json, v, "photo");
    for (int f = 0; f < GSFIX_FRAME_FILES && ok; f++) {
        out->files[f] = read_inner_path(json, v, file_keys[f]);
        ok = out->files[f] && read_digest(gsf_find_json_element(json, digests, (size_t)f), &out->digests[f]);
    }
    return ok && out->name && out->photo;
}

gsf_result gsfix_parse_sequence(gsf_context* ctx, const char* name, const char* text, size_t size, gsfix_sequence* out) {
    memset(out, 0, sizeof *out);
    gsf_json* json = &out->json;
    gsf_result result = gsf_parse_json(ctx, name, text, size, json);
    if (result != GSF_OK) return result;
    const gsf_json_value *root = json->values, *list = read_list(json, "gsfixer sequence 1", "frames", 2);
    out->scene = read_plain(json, root, "scene");
    out->kind = read_plain(json, root, "kind");
    out->caption = read_plain(json, root, "caption");
    out->cameras = read_inner_path(json, root, "cameras");
    if (!list || !out->scene || !out->kind || !out->caption || !out->cameras ||
        !read_whole(json, root, "views", 2, 1000, &out->views) || !read_whole(json, root, "sequence", 0, 1e6, &out->index) ||
        !read_whole(json, root, "width", 1, 65536, &out->width) || !read_whole(json, root, "height", 1, 65536, &out->height)) {
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not the manifest of a sequence of this version of gsfix", name);
    } else {
        out->frames = (gsfix_sequence_frame*)gsf_alloc_zeroed(ctx, list->count, sizeof *out->frames);
        if (!out->frames) result = GSF_ERROR_OUT_OF_MEMORY;
        for (uint32_t i = list->child; i && result == GSF_OK; i = json->values[i].next)
            if (!read_frame(json, &json->values[i], out->frames + out->frame_count++))
                result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: frame %zu is incomplete or leads out of the scene's folder",
                                  name, (unsigned)json->values[i].offset, out->frame_count - 1);
        if (result == GSF_OK && (!out->frames[0].reference || !out->frames[out->frame_count - 1].reference))
            result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: does not begin and end with a reference", name);
    }
    if (result != GSF_OK) gsfix_free_sequence(ctx, out);
    return result;
}

void gsfix_free_sequence(gsf_context* ctx, gsfix_sequence* sequence) {
    gsf_free(ctx, sequence->frames);
    gsf_destroy_json(ctx, &sequence->json);
    memset(sequence, 0, sizeof *sequence);
}

gsf_result gsfix_parse_scene_manifest(gsf_context* ctx, const char* name, const char* text, size_t size,
                                      gsfix_scene_manifest* out) {
    memset(out, 0, sizeof *out);
    gsf_json* json = &out->json;
    gsf_result result = gsf_parse_json(ctx, name, text, size, json);
    if (result != GSF_OK) return result;
    const gsf_json_value* list = read_list(json, "gsfixer scene 1", "sequences", 1);
    out->name = read_plain(json, json->values, "scene");
    out->settings = gsf_find_json_member(json, json->values, "settings");
    int ok = list && out->name && out->settings && out->settings->type == GSF_JSON_OBJECT;
    if (ok) {
        out->sequences = (gsfix_scene_sequence*)gsf_alloc_zeroed(ctx, list->count, sizeof *out->sequences);
        if (!out->sequences) result = GSF_ERROR_OUT_OF_MEMORY;
    }
    for (uint32_t i = ok && out->sequences ? list->child : 0; i && ok; i = json->values[i].next) {
        gsfix_scene_sequence* s = out->sequences + out->sequence_count++;
        const gsf_json_value* v = &json->values[i];
        int32_t frames = 0;
        s->file = read_inner_path(json, v, "file");
        ok = s->file && read_digest(gsf_find_json_member(json, v, "digest"), &s->digest) &&
             read_whole(json, v, "frames", 2, 1e6, &frames) && read_psnr(json, v, &s->psnr);
        s->frames = (size_t)frames;
    }
    if (!ok) result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not the manifest of a scene of this version of gsfix", name);
    if (result != GSF_OK) gsfix_free_scene_manifest(ctx, out);
    return result;
}

void gsfix_free_scene_manifest(gsf_context* ctx, gsfix_scene_manifest* manifest) {
    gsf_free(ctx, manifest->sequences);
    gsf_destroy_json(ctx, &manifest->json);
    memset(manifest, 0, sizeof *manifest);
}

gsf_result gsfix_load_scene_manifest(gsf_context* ctx, const char* path, gsfix_scene_manifest* out) {
    void* data = NULL;
    size_t size = 0;
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_read_file(ctx, path, &data, &size);
    if (result == GSF_OK) result = gsfix_parse_scene_manifest(ctx, path, (const char*)data, size, out);
    gsf_free(ctx, data);
    return result;
}

// ---- a scene's task ------------------------------------------------------------------

typedef struct dataset_sums { size_t sequences, frames; double psnr; } dataset_sums; // psnr: of frames that are no references

static gsf_result add_sequence(scene_run* run, gsf_buffer* t, gsfix_path name, dataset_sums* sums) {
    gsf_context* ctx = run->ctx;
    gsfix_sequence sequence;
    uint64_t size, digest;
    double sum = 0.0, count = 0.0;
    gsf_result result = gsfix_load_sequence(ctx, at_out(run, name), &sequence); // reads back what was written
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < sequence.frame_count; i++)
        if (!sequence.frames[i].reference) sum += sequence.frames[i].psnr, count += 1.0;
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "file", name.s);
    gsfix_json_text(ctx, t, "kind", sequence.kind);
    gsfix_json_number(ctx, t, "views", sequence.views);
    gsfix_json_number(ctx, t, "frames", (double)sequence.frame_count);
    gsfix_json_number(ctx, t, "psnr", sum / count);
    if (!gsfix_query_output(run->app, name.s, &size, &digest)) result = missing(run, name.s);
    else gsfix_json_text(ctx, t, "digest", gsfix_pathf("%016llx", (unsigned long long)digest).s);
    gsfix_json_end(ctx, t, '}');
    sums->sequences++;
    sums->frames += sequence.frame_count;
    if (count > 0.0) sums->psnr += sum / count;
    gsfix_free_sequence(ctx, &sequence);
    return result;
}

static gsf_result write_scene_manifest(scene_run* run, dataset_sums* sums) {
    gsf_context* ctx = run->ctx;
    gsf_buffer t = {0};
    gsf_result result = GSF_OK;
    gsfix_json_begin(ctx, &t, NULL, '{');
    gsfix_json_text(ctx, &t, "format", "gsfixer scene 1");
    gsfix_json_text(ctx, &t, "scene", run->name);
    gsfix_json_text(ctx, &t, "folder", run->scene.folder);
    gsfix_json_begin(ctx, &t, "settings", '{');
    t.size--; // drop the brace; the object itself is appended
    gsf_append_bytes(ctx, &t, run->settings.data, run->settings.size);
    gsfix_json_number(ctx, &t, "photos", (double)run->scene.view_count);
    gsfix_json_begin(ctx, &t, "sequences", '[');
    for (int kind = 0; kind < KIND_COUNT; kind++)
        for (int k = 0; k < run->plan->view_counts; k++)
            for (size_t s = 0; s + 1 < run->tracks[k].ref_count && result == GSF_OK; s++)
                if (run->plan->kinds >> kind & 1) result = add_sequence(run, &t, sequence_file(run, kind, k, s, ""), sums);
    gsfix_json_end(ctx, &t, ']');
    gsfix_json_end(ctx, &t, '}');
    if (result == GSF_OK) return write_text(run, gsfix_pathf("manifest.json"), &t);
    gsf_destroy_buffer(ctx, &t);
    return result;
}

static gsf_result prepare_scene(scene_run* run, const char* path) {
    gsf_context* ctx = run->ctx;
    gsf_result result = gsfix_load_scene(run->app, path, &run->scene);
    if (result != GSF_OK) return result;
    run->used = (uint8_t*)gsf_alloc_zeroed(ctx, run->scene.view_count + 1, 1);
    if (!run->used) return GSF_ERROR_OUT_OF_MEMORY;
    for (int k = 0; k < run->plan->view_counts && result == GSF_OK; k++) result = make_track(run, k);
    if (result == GSF_OK) result = digest_scene(run);
    if (result == GSF_OK) result = open_scene_out(run);
    if (result == GSF_OK) result = meet_earlier(run);
    if (result == GSF_OK)
        run->near_plane = gsf_splat_measure_near_plane(&run->scene.views[0].camera, sizeof run->scene.views[0],
                                                       run->scene.view_count);
    return result == GSF_OK ? gsf_splat_make_rasterizer(ctx, &run->rasterizer) : result;
}

static void free_scene_run(scene_run* run) {
    gsf_context* ctx = run->ctx;
    gsf_splat_destroy_trainer(ctx, run->trainer);
    gsf_splat_destroy_rasterizer(ctx, run->rasterizer);
    for (int k = 0; k < MAX_VIEW_COUNTS; k++) {
        gsf_free(ctx, run->tracks[k].frames);
        gsf_free(ctx, run->tracks[k].refs);
    }
    gsf_free(ctx, run->used);
    gsf_free(ctx, run->saved);
    gsf_destroy_buffer(ctx, &run->settings);
    gsf_splat_destroy_scene(ctx, &run->scene);
}

gsf_result gsfix_make_dataset_scene(gsfix_app* app, const dataset_plan* plan, const char* name, const char* path) {
    static const scene_run zero;
    scene_run run = zero;
    dataset_sums sums = {0, 0, 0.0};
    const double begin = gsfix_now();
    run.app = app;
    run.ctx = &app->ctx;
    run.plan = plan;
    run.name = name;
    const int sparse = run.plan->kinds & 1, others = (run.plan->kinds & ~1) != 0;
    run.model_count = (sparse ? run.plan->view_counts : 0) + others;
    gsf_result result = prepare_scene(&run, path);
    if (result == GSF_OK) result = write_photos(&run);
    for (int k = 0; sparse && k < run.plan->view_counts && result == GSF_OK; k++) result = make_model(&run, k);
    if (result == GSF_OK && others) result = make_model(&run, -1);
    if (result == GSF_OK) result = write_scene_manifest(&run, &sums);
    if (result == GSF_OK) result = gsfix_remove_output(app, "checkpoint");
    if (result == GSF_OK) {
        const double psnr = sums.psnr / (double)sums.sequences;
        gsfix_json_number(run.ctx, &app->json, "sequences", (double)sums.sequences);
        gsfix_json_number(run.ctx, &app->json, "frames", (double)sums.frames);
        gsfix_json_number(run.ctx, &app->json, "psnr", psnr);
        gsfix_json_number(run.ctx, &app->json, "seconds", gsfix_now() - begin);
        gsfix_print(app, "%-20s %3zu sequences, %4zu frames, artifacts at %.2f dB, %.1f s", run.name, sums.sequences,
                    sums.frames, psnr, gsfix_now() - begin);
    }
    free_scene_run(&run);
    return result;
}

static gsf_result run_scene(gsfix_app* app, void* user, size_t task) {
    const dataset_plan* plan = (const dataset_plan*)user;
    return gsfix_make_dataset_scene(app, plan, plan->names[task], app->o.inputs[task]);
}

int gsfix_has_dataset_scene(gsfix_app* app, const dataset_plan* plan) {
    gsf_context* ctx = &app->ctx;
    const gsfix_path path = gsfix_pathf("%s/manifest.json", app->o.out);
    gsfix_scene_manifest manifest;
    gsf_buffer settings = {0};
    if (!gsfix_exists(path.s) || gsfix_exists(gsfix_pathf("%s/checkpoint", app->o.out).s)) return 0;
    gsf_append_bytes(ctx, &settings, plan->settings.data, plan->settings.size);
    gsf_append_bytes(ctx, &settings, "}", 1);
    const gsf_result result = gsfix_load_scene_manifest(ctx, path.s, &manifest);
    const int done = result == GSF_OK && !settings.failed &&
                     gsfix_compare_settings(ctx, path.s, &settings, &manifest.json, manifest.settings) == GSF_OK;
    if (result == GSF_OK) gsfix_free_scene_manifest(ctx, &manifest);
    gsf_destroy_buffer(ctx, &settings);
    ctx->error[0] = 0;
    return done;
}

static int is_scene_done(gsfix_app* app, void* user, size_t task) {
    (void)task;
    return gsfix_has_dataset_scene(app, (const dataset_plan*)user);
}

// ---- all scenes --------------------------------------------------------------------

static gsf_result claim_dataset(gsfix_app* app, void* user) {
    (void)user;
    const gsf_result result = gsfix_claim(app, "scenes.txt");
    return result == GSF_OK ? gsfix_claim(app, "dataset.json") : result;
}

static gsf_result merge_scene(gsfix_app* app, const char* name, gsf_buffer* t, dataset_sums* sums) {
    gsf_context* ctx = &app->ctx;
    const gsfix_path path = gsfix_pathf("%s/%s/manifest.json", app->o.out, name);
    gsfix_scene_manifest m;
    uint64_t size = 0, digest = 0;
    size_t frames = 0;
    double psnr = 0.0;
    gsf_result result = gsfix_load_scene_manifest(ctx, path.s, &m);
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < m.sequence_count; i++) frames += m.sequences[i].frames, psnr += m.sequences[i].psnr;
    if (strcmp(m.name, name) != 0 || !gsfix_digest_file(path.s, &size, &digest))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not the manifest of this scene", path.s);
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "scene", name);
    gsfix_json_number(ctx, t, "sequences", (double)m.sequence_count);
    gsfix_json_number(ctx, t, "frames", (double)frames);
    gsfix_json_number(ctx, t, "psnr", psnr / (double)m.sequence_count);
    gsfix_json_text(ctx, t, "digest", gsfix_pathf("%016llx", (unsigned long long)digest).s);
    gsfix_json_end(ctx, t, '}');
    sums->sequences += m.sequence_count;
    sums->frames += frames;
    gsfix_free_scene_manifest(ctx, &m);
    return result;
}

static gsf_result merge_dataset(gsfix_app* app, void* user) {
    const dataset_plan* plan = (const dataset_plan*)user;
    gsf_context* ctx = &app->ctx;
    const char* out = app->o.out;
    const size_t count = (size_t)app->o.input_count;
    dataset_sums sums = {0, 0, 0.0};
    gsf_buffer t = {0}, list = {0};
    gsf_result result = GSF_OK;
    gsfix_json_begin(ctx, &t, NULL, '{');
    gsfix_json_text(ctx, &t, "format", "gsfixer dataset 1");
    gsfix_json_text(ctx, &t, "version", GSF_VERSION);
    gsfix_json_begin(ctx, &t, "scenes", '[');
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        result = merge_scene(app, plan->names[i], &t, &sums);
        gsf_append_text(ctx, &list, "%s\n", plan->names[i]);
    }
    gsfix_json_end(ctx, &t, ']');
    gsfix_json_end(ctx, &t, '}');
    gsf_append_bytes(ctx, &t, "\n", 1);
    if (result == GSF_OK && (t.failed || list.failed)) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) result = gsf_write_file(ctx, gsfix_pathf("%s/scenes.txt", out).s, list.data, list.size);
    if (result == GSF_OK) result = gsf_write_file(ctx, gsfix_pathf("%s/dataset.json", out).s, t.data, t.size);
    if (result == GSF_OK) {
        gsfix_json_number(ctx, &app->json, "scenes", (double)count);
        gsfix_json_number(ctx, &app->json, "sequences", (double)sums.sequences);
        gsfix_json_number(ctx, &app->json, "frames", (double)sums.frames);
        gsfix_json_number(ctx, &app->json, "seconds", gsfix_now() - app->started);
        gsfix_print(app, "wrote      %s: %zu scenes, %zu sequences, %zu frames, %.1f s", out, count, sums.sequences,
                    sums.frames, gsfix_now() - app->started);
    }
    gsf_destroy_buffer(ctx, &t);
    gsf_destroy_buffer(ctx, &list);
    return result;
}

int gsfix_make_dataset_plan(gsfix_app* app, dataset_plan** out) {
    *out = (dataset_plan*)gsf_alloc_zeroed(&app->ctx, 1, sizeof **out);
    if (!*out) return gsfix_failed(app);
    return resolve_plan(app, *out);
}

void gsfix_destroy_dataset_plan(gsfix_app* app, dataset_plan* plan) {
    if (!plan) return;
    gsfix_names names = {plan->names, plan->names ? (size_t)app->o.input_count : 0};
    gsfix_free_names(&app->ctx, &names);
    gsf_destroy_buffer(&app->ctx, &plan->settings);
    gsf_free(&app->ctx, plan);
}

int gsfix_run_dataset(gsfix_app* app) {
    dataset_plan* plan;
    int code = gsfix_make_dataset_plan(app, &plan);
    if (!code && gsfix_name_scenes(app, &plan->names) != GSF_OK) code = gsfix_failed(app);
    if (!code) {
        const gsfix_tasks tasks = {plan->names, (size_t)app->o.input_count, plan, claim_dataset, is_scene_done, run_scene,
                                   merge_dataset, NULL, 0};
        code = gsfix_run_tasks(app, &tasks);
    }
    gsfix_destroy_dataset_plan(app, plan);
    return code;
}

// ---- gsfix info ----------------------------------------------------------------------

int gsfix_is_manifest(const char* path) {
    static const char begin[] = "{\"format\":\"gsfixer ";
    char text[sizeof begin] = "";
#ifdef _WIN32
    FILE* file = gsfix_w_fopen(path);
#else
    FILE* file = fopen(path, "rb");
#endif
    const size_t n = file ? fread(text, 1, sizeof begin - 1, file) : 0;
    if (file) fclose(file);
    return n == sizeof begin - 1 && memcmp(text, begin, n) == 0;
}

static gsf_result check_sequence(gsfix_app* app, const char* folder, gsfix_path path, dataset_sums* sums) {
    gsf_context* ctx = &app->ctx;
    gsfix_sequence q;
    double sum = 0.0, count = 0.0;
    gsf_result result = gsfix_load_sequence(ctx, path, &q);
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < q.frame_count && result == GSF_OK; i++) {
        if (!q.frames[i].reference) sum += q.frames[i].psnr, count += 1.0;
        for (int f = 0; f < GSFIX_FRAME_FILES && result == GSF_OK; f++) {
            const gsfix_path file = gsfix_pathf("%s/%s", folder, q.frames[i].files[f]);
            uint64_t size, digest;
            if (!gsfix_digest_file(file.s, &size, &digest)) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be read", file.s);
            else if (digest != q.frames[i].digests[f])
                result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not as the manifest says", file.s);
        }
    }
    gsf_camera* cameras = NULL;
    size_t camera_count = 0;
    if (result == GSF_OK) result = gsf_load_cameras(ctx, gsfix_pathf("%s/%s", folder, q.cameras).s, &cameras, &camera_count);
    if (result == GSF_OK && camera_count != q.frame_count)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s/%s: %zu cameras for %zu frames", folder, q.cameras, camera_count,
                          q.frame_count);
    gsf_free(ctx, cameras);
    if (result == GSF_OK)
        gsfix_print(app, "%-20s %-8s %2d views, sequence %d: %zu frames of %d x %d, artifacts at %.2f dB", q.scene, q.kind,
                    q.views, q.index, q.frame_count, q.width, q.height, sum / count);
    sums->sequences++;
    sums->frames += q.frame_count;
    gsfix_free_sequence(ctx, &q);
    return result;
}

gsf_result gsfix_info_dataset(gsfix_app* app, const char* path) {
    gsf_context* ctx = &app->ctx;
    const char* slash = strrchr(path, '/');
    const gsfix_path folder = slash ? gsfix_pathf("%.*s", (int)(slash - path), path) : gsfix_pathf(".");
    dataset_sums sums = {0, 0, 0.0};
    gsfix_scene_manifest m;
    gsf_result result = gsfix_load_scene_manifest(ctx, path, &m);
    if (result == GSF_OK) {
        for (size_t i = 0; i < m.sequence_count && result == GSF_OK; i++) {
            const gsfix_path file = gsfix_pathf("%s/%s", folder.s, m.sequences[i].file);
            uint64_t size, digest = 0;
            if (!gsfix_digest_file(file.s, &size, &digest) || digest != m.sequences[i].digest)
                result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: missing, or not as the manifest says", file.s);
            if (result == GSF_OK) result = check_sequence(app, folder.s, file, &sums);
        }
        gsfix_free_scene_manifest(ctx, &m);
    } else if (result == GSF_ERROR_FORMAT) {
        result = check_sequence(app, gsfix_pathf("%s/..", folder.s).s, gsfix_pathf("%s", path), &sums);
    }
    if (result != GSF_OK) return result;
    gsfix_json_text(ctx, &app->json, "kind", "dataset");
    gsfix_json_number(ctx, &app->json, "sequences", (double)sums.sequences);
    gsfix_json_number(ctx, &app->json, "frames", (double)sums.frames);
    gsfix_print(app, "all files are as their manifests say");
    return GSF_OK;
}
