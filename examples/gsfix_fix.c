// gsfix_fix.c - the command fix: scene -> initial splats -> training with repair rounds -> splats, metrics, report
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <math.h>
#include <stddef.h>
#ifdef __GLIBC__
#include <malloc.h>
#endif

// ---- defaults --------------------------------------------------------------------

static const gsfix_quality qualities[] = { // savings and costs: bench/QUALITY.md
    {"exact", GSF_QUALITY_EXACT, 50, GSF_NN_SOLVER_DDIM, 0},
    {"balanced", GSF_QUALITY_BALANCED, 50, GSF_NN_SOLVER_DDIM, 0},
    {"fast", GSF_QUALITY_FAST, 10, GSF_NN_SOLVER_UNIPC, 1},
};

// Names of gsf_initial_kind for --init.
static const char* const initial_kinds[] = {NULL, "both", "tracks", "embree", "all", "dense", "random"};

static gsf_initial_kind find_initial_kind(const char* name) {
    for (int i = 1; name && i < (int)(sizeof initial_kinds / sizeof *initial_kinds); i++)
        if (strcmp(initial_kinds[i], name) == 0) return (gsf_initial_kind)i;
    return GSF_INITIAL_AUTO;
}

const gsfix_quality* gsfix_find_quality(const char* name) {
    for (size_t i = 0; name && i < sizeof qualities / sizeof *qualities; i++)
        if (strcmp(qualities[i].name, name) == 0) return &qualities[i];
    return &qualities[1];
}

// ---- settings --------------------------------------------------------------------

enum { SET_WHOLE, SET_REAL, SET_SWITCH, SET_COUNT }; // int32_t, float, int32_t of 0 (off) or 1 (on), size_t
typedef struct setting { const char* name; int kind; size_t offset; double least, most; } setting;
#define TRAIN_AT(field) offsetof(gsfix_setup, fix.train.field)
#define FIX_AT(field) offsetof(gsfix_setup, fix.field)
#define DENSE_AT(field) offsetof(gsfix_setup, initial.dense.field)
// Zero selects the library's default, see gsf_train_desc, gsf_fix_desc and gsf_dense_desc; -1 is allowed where those give
// negative values a meaning.
static const setting settings[] = {
    {"sh_degree", SET_WHOLE, offsetof(gsfix_setup, initial.sh_degree), 0, 3},
    {"random_points", SET_WHOLE, offsetof(gsfix_setup, initial.random_points), 1, 1e8},
    {"dropout", SET_REAL, TRAIN_AT(dropout), 0, 0.99},
    {"opacity_decay", SET_REAL, TRAIN_AT(opacity_decay), 0, 1},
    {"scale_penalty", SET_REAL, TRAIN_AT(scale_penalty), -1, 1000},
    {"opacity_penalty", SET_REAL, TRAIN_AT(opacity_penalty), -1, 1000},
    {"depth_smoothness", SET_REAL, TRAIN_AT(depth_smoothness), 0, 1000},
    {"sh_interval", SET_WHOLE, TRAIN_AT(sh_interval), 0, 1e9},
    {"coarse_until", SET_WHOLE, TRAIN_AT(coarse_until), 0, 1e9},
    {"lr_means", SET_REAL, TRAIN_AT(lr_means), -1, 1},
    {"lr_means_final", SET_REAL, TRAIN_AT(lr_means_final), 0, 1},
    {"lr_sh_dc", SET_REAL, TRAIN_AT(lr_sh_dc), -1, 1},
    {"lr_sh_rest", SET_REAL, TRAIN_AT(lr_sh_rest), -1, 1},
    {"lr_opacity", SET_REAL, TRAIN_AT(lr_opacity), -1, 1},
    {"lr_scales", SET_REAL, TRAIN_AT(lr_scales), -1, 1},
    {"lr_quats", SET_REAL, TRAIN_AT(lr_quats), -1, 1},
    {"lambda_ssim", SET_REAL, TRAIN_AT(lambda_ssim), -1, 1},
    {"densify_from", SET_WHOLE, TRAIN_AT(densify_from), -1, 1e9},
    {"densify_until", SET_WHOLE, TRAIN_AT(densify_until), -1, 1e9},
    {"densify_interval", SET_WHOLE, TRAIN_AT(densify_interval), 0, 1e9},
    {"densify_grad", SET_REAL, TRAIN_AT(densify_grad), -1, 1000},
    {"densify_absolute", SET_SWITCH, TRAIN_AT(densify_absolute), 0, 1},
    {"densify_shared", SET_SWITCH, TRAIN_AT(densify_shared), 0, 1},
    {"densify_scale", SET_REAL, TRAIN_AT(densify_scale), -1, 1000},
    {"prune_opacity", SET_REAL, TRAIN_AT(prune_opacity), -1, 1},
    {"prune_scale", SET_REAL, TRAIN_AT(prune_scale), 0, 1e6},
    {"opacity_reset_interval", SET_WHOLE, TRAIN_AT(opacity_reset_interval), -1, 1e9},
    {"max_splats", SET_COUNT, TRAIN_AT(max_splats), 0, 1e9},
    {"mcmc", SET_SWITCH, TRAIN_AT(mcmc), 0, 1},
    {"mcmc_noise", SET_REAL, TRAIN_AT(mcmc_noise), -1, 1e9},
    {"sharpness", SET_REAL, TRAIN_AT(sharpness), 0, 1000},
    {"sharpness_from", SET_WHOLE, TRAIN_AT(sharpness_from), -1, 1e9},
    {"lazy_adam", SET_SWITCH, TRAIN_AT(lazy_adam), 0, 1},
    {"antialiased", SET_SWITCH, TRAIN_AT(render.antialiased), 0, 1},
    {"rounds", SET_WHOLE, FIX_AT(rounds), -1, 1000},
    {"first_round", SET_WHOLE, FIX_AT(first_round), 0, 1e9},
    {"last_round", SET_WHOLE, FIX_AT(last_round), 0, 1e9},
    {"windows", SET_WHOLE, FIX_AT(windows), 0, 1000},
    {"window_frames", SET_WHOLE, FIX_AT(window_frames), 0, 1000},
    {"lambda", SET_REAL, FIX_AT(lambda), -1, 1000},
    {"skip_psnr", SET_REAL, FIX_AT(skip_psnr), 0, 1000},
    {"frame_scale", SET_REAL, FIX_AT(frame_scale), 0, 1},
    {"warp_weight", SET_REAL, FIX_AT(warp_weight), -1, 1e6},
    {"max_pixels", SET_WHOLE, FIX_AT(max_pixels), 0, 1e9},
    {"dense_points", SET_COUNT, DENSE_AT(max_points), 1, 1e8},
    {"dense_spacing", SET_WHOLE, DENSE_AT(spacing), 0, 10000},
    {"dense_max_cost", SET_REAL, DENSE_AT(max_cost), 0, 2},
    {"dense_max_reprojection", SET_REAL, DENSE_AT(max_reprojection), 0, 1000},
    {"dense_max_depth_error", SET_REAL, DENSE_AT(max_depth_error), 0, 1},
    {"dense_max_normal_angle", SET_REAL, DENSE_AT(max_normal_angle), 0, 180},
    {"dense_min_consistent", SET_WHOLE, DENSE_AT(min_consistent), 0, 8},
    {"dense_max_cost_many", SET_REAL, DENSE_AT(max_cost_many), 0, 2},
};
enum { SETTING_COUNT = sizeof settings / sizeof settings[0] };

void gsfix_print_settings(FILE* to) {
    size_t column = 0;
    for (int i = 0; i < SETTING_COUNT; i++) {
        fprintf(to, column ? ", %s" : "        %s", settings[i].name);
        column += strlen(settings[i].name) + 2;
        if (column > 90 || i + 1 == SETTING_COUNT)
            fprintf(to, column > 90 && i + 1 < SETTING_COUNT ? ",\n" : "\n"), column = 0;
    }
}

static int apply_settings(gsfix_app* app, gsfix_setup* setup) {
    for (const char* p = app->o.settings; p && *p;) {
        const size_t n = strcspn(p, ","), name = strcspn(p, "=");
        int i = 0;
        while (i < SETTING_COUNT && !(strlen(settings[i].name) == name && strncmp(settings[i].name, p, name) == 0)) i++;
        if (name >= n || i == SETTING_COUNT) return gsfix_misused(app, "--set: no setting \"%.*s\"", (int)n, p);
        const gsfix_path value_text = gsfix_pathf("%.*s", (int)(n - name - 1), p + name + 1);
        const char* value = value_text.s;
        char* end;
        char* field = (char*)setup + settings[i].offset;
        const double x = strtod(value, &end);
        const int kind = settings[i].kind;
        if (end == value || *end || !(x >= settings[i].least && x <= settings[i].most) || (kind != SET_REAL && x != floor(x)))
            return gsfix_misused(app, "--set %.*s: expected a %s from %g to %g", (int)n, p,
                                 kind == SET_REAL ? "number" : "whole number", settings[i].least, settings[i].most);
        if (kind == SET_REAL) *(float*)(void*)field = (float)x;
        else if (kind == SET_COUNT) *(size_t*)(void*)field = (size_t)x;
        else *(int32_t*)(void*)field = (int32_t)x;
        p += n + (p[n] == ',');
    }
    return 0;
}

// ---- --also ----------------------------------------------------------------------

static const char* const also_formats[] = {"splat", "spz", "glb"};
enum { ALSO_COUNT = sizeof also_formats / sizeof *also_formats };

static const char* also_format_at(const char* word) { // the format that a list's word names, or NULL
    const size_t n = strcspn(word, ",");
    for (int i = 0; i < ALSO_COUNT; i++)
        if (strlen(also_formats[i]) == n && strncmp(also_formats[i], word, n) == 0) return also_formats[i];
    return NULL;
}

static int wants_also(const gsfix_app* app, int format) {
    for (const char* p = app->o.also ? app->o.also : ""; *p; p += strcspn(p, ","), p += *p == ',')
        if (also_format_at(p) == also_formats[format]) return 1;
    return 0;
}

static int has_restorer(const gsfix_app* app) { return app->o.restorer && strcmp(app->o.restorer, "none") != 0; }

#define BY_VIEWS (-2.0f) // no value of --set: what gsf_splat_resolve_few_view_desc takes for the number of photos
#define BY_START (-2)    // no value of --set: longer for a start of few points, which have more to grow

void gsfix_settle_train(gsf_train_desc* train, gsf_initial_kind start, size_t view_count) {
    const gsf_train_desc few = gsf_splat_resolve_few_view_desc(NULL, view_count, GSF_QUALITY_BALANCED).train;
    if (train->dropout == BY_VIEWS) train->dropout = few.dropout;
    if (train->opacity_decay == BY_VIEWS) train->opacity_decay = few.opacity_decay;
    if (train->lr_scales == BY_VIEWS) // the splats of a sparse start are large and must not grow faster
        train->lr_scales = start == GSF_INITIAL_AUTO || start == GSF_INITIAL_DENSE ? few.lr_scales : 0.0f;
    if (train->densify_until == BY_START)
        train->densify_until = start == GSF_INITIAL_TRACKS && !train->mcmc ? 2 * train->iterations / 3 : 0;
}

int gsfix_resolve_setup(gsfix_app* app, gsfix_setup* setup) {
    memset(setup, 0, sizeof *setup);
    setup->fix = gsf_splat_resolve_few_view_desc(NULL, 0, gsfix_find_quality(app->o.quality)->work);
    setup->initial.kind = find_initial_kind(app->o.init);
    setup->initial.seed = app->o.seed;
    setup->initial.sh_degree = 3;
    gsf_train_desc* train = &setup->fix.train;
    train->dropout = train->opacity_decay = train->lr_scales = BY_VIEWS;
    if (app->o.iterations) train->iterations = app->o.iterations;
    train->seed = app->o.seed;
    const int regularized = !app->o.regularize || strcmp(app->o.regularize, "off") != 0;
    if (regularized) train->densify_until = BY_START;
    else {
        train->dropout = train->opacity_decay = train->scale_penalty = train->opacity_penalty = train->depth_smoothness = 0.0f;
        train->lr_scales = 0.0f;
    }
    setup->fix.trajectory = gsfix_path_kind(app->o.trajectory);
    if (app->o.fixed_exposure) setup->fix.auto_exposure = -1.0f;
    int code = apply_settings(app, setup);
    const char* background = app->o.background ? app->o.background : regularized ? "photos" : "black";
    if (!code) code = gsfix_background(app, background, train->background, &train->background_kind);
    if (code) return code;
    if (setup->initial.sh_degree == 0) setup->initial.sh_degree = -1; // an explicit 0: the desc's zero means default
    if (app->o.path && app->o.trajectory) return gsfix_misused(app, "--path and --trajectory exclude each other");
    for (const char* p = app->o.also ? app->o.also : ""; *p; p += strcspn(p, ","), p += *p == ',')
        if (!also_format_at(p)) return gsfix_misused(app, "--also: \"%s\" is not a list of splat, spz, glb", app->o.also);
    if (app->o.compare && !has_restorer(app))
        return gsfix_misused(app, "--compare: without a --restorer there is nothing to compare");
    if (app->o.filtered && !has_restorer(app)) return gsfix_misused(app, "--filtered: needs a --restorer");
    if (app->o.fixed_exposure && !app->o.filtered) return gsfix_misused(app, "--fixed-exposure: needs --filtered");
    return gsfix_check_restorer(app);
}

// ---- a run -----------------------------------------------------------------------

const char* const gsfix_stage_names[GSFIX_STAGES] = {"init", "train", "render", "restore", "distill",
                                                         "checkpoint", "save", "compare", "copies"};

typedef struct fix_run {
    gsfix_app* app;
    gsf_context* ctx;
    gsfix_setup setup;
    gsf_scene scene;
    gsfix_split split;
    gsf_image* masks; // per test view, or NULL
    gsf_camera* path; // from --path, or NULL
    size_t path_count;
    gsf_splats initial;
    gsf_initial_stats initial_stats;
    gsf_restorer restorer;
    int has_restorer;
    int comparing; // set during the run without repair, the first one of --compare
    const gsfix_fix_task* task; // of another command, or NULL
    gsf_fixer* fixer; // what is trained now, at the end what is measured
    gsf_fixer* copies[GSFIX_COPIES_MOST]; // those of --copies, once the run itself, the first of them, is done
    int copy;         // trained now: 0 the run itself, then the others, their number for what joins them
    gsf_buffer switches; // JSON object
    const gsfix_read_file* inputs;
    size_t input_count;
    int resuming;
    int checkpoint_failed; // the last checkpoint could not be written
    const char* rays; // backend that traced the visibility rays
    gsfix_history history;
    double total_before, seconds_before[GSFIX_STAGES]; // spent by the earlier runs that this one continues
    int32_t iteration, iterations, eval_every, checkpoint_every;
    double checkpoint_last, checkpoint_sum, checkpoint_end; // seconds for the last one and for all; end time of the last
} fix_run;

static size_t copy_count(const fix_run* run) { return run->app->o.copies > 1 ? (size_t)run->app->o.copies : 1; }

static gsfix_path copy_file(int copy) { return gsfix_pathf("copies/%d.ply", copy + 1); } // 0: the run itself

static void add_seconds(fix_run* run, int stage, double* since) {
    const double now = gsfix_now();
    if (run->comparing && stage != GSFIX_CHECKPOINT) stage = GSFIX_COMPARE;
    if (run->copy && stage != GSFIX_CHECKPOINT) stage = GSFIX_COPIES;
    run->history.seconds[stage] += now - *since;
    *since = now;
}

// Makes room for one more element of a list in the history. list: the member; stem: prefix of its _count and _room
#define GROW(ctx, h, list, stem) \
    gsfix_grow(ctx, (void**)&(h)->list, &(h)->stem##_room, (h)->stem##_count, sizeof *(h)->list)

// ---- initial splats --------------------------------------------------------------

static gsf_result make_initial(fix_run* run) {
    gsf_initial_stats* stats = &run->initial_stats;
    const gsf_result result = gsf_splat_make_initial_splats(run->ctx, &run->scene, run->split.train,
                                                            run->split.train_count, &run->setup.initial, &run->initial, stats);
    if (result != GSF_OK) return result;
    run->setup.initial = stats->used;
    const gsf_initial_kind kind = stats->used.kind;
    const int traced = kind == GSF_INITIAL_BOTH || kind == GSF_INITIAL_RAYS || kind == GSF_INITIAL_DENSE;
    run->rays = !traced || !run->scene.point_count ? "none" : stats->visibility.used_embree ? "embree" : "z-buffer";
    return GSF_OK;
}

static void tell_start(const fix_run* run) {
    const gsf_initial_stats* stats = &run->initial_stats;
    if (stats->used.kind == GSF_INITIAL_DENSE)
        gsfix_note(run->app, "%zu points that a training view sees; %zu more by stereo between %zu pairs of views in %.1f s",
                   stats->scene_points, stats->new_points, stats->dense.pairs,
                   stats->dense.seconds_prepare + stats->dense.seconds_match + stats->dense.seconds_fuse);
    gsfix_note(run->app, "%zu training views, %zu held out; %zu initial splats%s", run->split.train_count,
               run->split.test_count, run->initial.count, run->resuming ? "; going on from the checkpoint" : "");
}

// ---- held-out views --------------------------------------------------------------

static gsf_result render_view(fix_run* run, size_t i, gsf_image* color) { // test view i, clamped to [0,1]
    const gsf_camera* camera = &run->scene.views[run->split.test[i]].camera;
    gsf_render_output out = {0};
    gsf_result result = gsf_make_image(run->ctx, GSF_F32, camera->width, camera->height, 3, color);
    if (result != GSF_OK) return result;
    out.color = *color;
    result = gsf_splat_render_trainer(run->ctx, gsf_splat_get_trainer(run->fixer), camera, &out);
    if (result == GSF_OK) gsfix_clamp(color);
    else gsf_destroy_image(run->ctx, color);
    return result;
}

// Scores over the pixels of a mask (NULL: all). NaN if the mask is empty.
static gsf_result score_pixels(fix_run* run, const gsf_image* color, const gsf_image* photo, const gsf_image* mask,
                               double* psnr, double* ssim) {
    *psnr = NAN;
    if (ssim) *ssim = NAN;
    if (mask && !gsfix_counts_any(mask)) return GSF_OK;
    gsf_result result = gsf_measure_image(run->ctx, GSF_METRIC_PSNR, color, photo, mask, psnr);
    if (result == GSF_OK && ssim) result = gsf_measure_image(run->ctx, GSF_METRIC_SSIM_3DGS, color, photo, mask, ssim);
    return result;
}

// The images to measure for a test view whose photo has masked pixels: render and photo with these pixels black, so that they
// do not enter the windows of SSIM; the mask; and, if wanted, the mask of the seen pixels among them.
typedef struct cut_view { gsf_image color, photo, counts, seen; } cut_view;

static gsf_result cut_to_photo(gsf_context* ctx, const gsf_scene_view* view, const gsf_image* color, const gsf_image* seen,
                               cut_view* out) {
    const gsf_image *photo = &view->image, *weight = &view->weight;
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_make_image(ctx, GSF_F32, photo->width, photo->height, 3, &out->color);
    if (result == GSF_OK) result = gsf_convert_image(ctx, color, &out->color);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 3, &out->photo);
    if (result == GSF_OK) result = gsf_convert_image(ctx, photo, &out->photo);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 1, &out->counts);
    if (result == GSF_OK && seen) result = gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 1, &out->seen);
    for (size_t i = 0; result == GSF_OK && i < (size_t)photo->width * (size_t)photo->height; i++) {
        const int counts = ((const uint8_t*)weight->data)[i] >= 128;
        ((uint8_t*)out->counts.data)[i] = (uint8_t)counts;
        if (seen) ((uint8_t*)out->seen.data)[i] = counts && ((const uint8_t*)seen->data)[i];
        for (size_t k = 3 * i; k < 3 * i + 3 && !counts; k++) {
            ((float*)out->color.data)[k] = 0.0f;
            ((uint8_t*)out->photo.data)[k] = 0;
        }
    }
    return result;
}

static gsf_result score_view(fix_run* run, size_t i, const gsf_image* color, int with_ssim, gsfix_score* out) {
    const gsf_scene_view* view = &run->scene.views[run->split.test[i]];
    const gsf_image *photo = &view->image, *counts = NULL, *seen = run->masks ? &run->masks[i] : NULL;
    cut_view cut = {0};
    gsf_result result = GSF_OK;
    out->ssim = out->psnr_seen = out->ssim_seen = NAN;
    if (view->weight.data) {
        result = cut_to_photo(run->ctx, view, color, seen, &cut);
        color = &cut.color;
        photo = &cut.photo;
        counts = &cut.counts;
        if (seen) seen = &cut.seen;
    }
    if (result == GSF_OK) result = score_pixels(run, color, photo, counts, &out->psnr, with_ssim ? &out->ssim : NULL);
    if (result == GSF_OK && seen)
        result = score_pixels(run, color, photo, seen, &out->psnr_seen, with_ssim ? &out->ssim_seen : NULL);
    gsf_destroy_image(run->ctx, &cut.color);
    gsf_destroy_image(run->ctx, &cut.photo);
    gsf_destroy_image(run->ctx, &cut.counts);
    gsf_destroy_image(run->ctx, &cut.seen);
    return result;
}

static gsfix_score mean_score(const gsfix_score* scores, size_t count) { // each score averaged over the views that have it
    double sums[4] = {0}, counts[4] = {0};
    for (size_t i = 0; i < count; i++) {
        const double values[4] = {scores[i].psnr, scores[i].ssim, scores[i].psnr_seen, scores[i].ssim_seen};
        for (int k = 0; k < 4; k++)
            if (!isnan(values[k])) sums[k] += values[k], counts[k] += 1.0;
    }
    const gsfix_score mean = {sums[0] / counts[0], sums[1] / counts[1], sums[2] / counts[2], sums[3] / counts[3]};
    return mean;
}

// Renders and scores all held-out views. folder: where the images are saved, or NULL. scores: one per view.
static gsf_result evaluate(fix_run* run, const char* folder, int with_ssim, gsfix_score* scores) {
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < run->split.test_count && result == GSF_OK; i++) {
        gsf_image color;
        result = render_view(run, i, &color);
        if (result != GSF_OK) return result;
        result = score_view(run, i, &color, with_ssim, scores + i);
        const gsfix_path name = gsfix_view_stem(&run->scene, run->split.test[i]);
        if (result == GSF_OK && folder)
            result = gsf_save_image(run->ctx, gsfix_pathf("%s/%s.png", folder, name.s).s, &color);
        gsf_destroy_image(run->ctx, &color);
    }
    return result;
}

// Has the restorer clean up the renders of all held-out views, and those of the copies, and scores them.
static gsf_result evaluate_filtered(fix_run* run, gsfix_score* scores) {
    gsf_context* ctx = run->ctx;
    gsf_fixer* fixers[GSFIX_COPIES_MOST + 1] = {run->fixer};
    size_t count = 1;
    for (size_t i = 0; i < GSFIX_COPIES_MOST && run->copies[i]; i++) fixers[count++] = run->copies[i];
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < run->split.test_count && result == GSF_OK; i++) {
        const gsf_camera* camera = &run->scene.views[run->split.test[i]].camera;
        const gsfix_path name = gsfix_view_stem(&run->scene, run->split.test[i]);
        gsf_image color, confidence = {0};
        result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &color);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &confidence);
        if (result == GSF_OK)
            result = gsf_splat_restore_views(ctx, fixers, count, camera, 1, &color, &confidence);
        if (result == GSF_OK) gsfix_clamp(&color);
        if (result == GSF_OK) result = score_view(run, i, &color, 1, scores + i);
        if (result == GSF_OK)
            result = gsf_save_image(ctx, gsfix_pathf("%s/filtered/%s.png", run->app->o.out, name.s).s, &color);
        gsf_destroy_image(ctx, &color);
        gsf_destroy_image(ctx, &confidence);
    }
    return result;
}

static gsf_result add_curve_point(fix_run* run) {
    gsfix_history* h = &run->history;
    if (run->task || run->copy || !run->split.test_count) return GSF_OK;
    if (h->curve_count && h->curve[h->curve_count - 1].iteration == run->iteration) return GSF_OK;
    gsf_result result = GROW(run->ctx, h, curve, curve);
    gsfix_score* scores = (gsfix_score*)gsf_alloc(run->ctx, run->split.test_count, sizeof *scores);
    if (!scores) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) result = evaluate(run, NULL, 0, scores);
    if (result == GSF_OK) {
        const gsfix_score mean = mean_score(scores, run->split.test_count);
        gsfix_curve_point* p = &h->curve[h->curve_count++];
        p->iteration = run->iteration;
        p->splats = gsf_splat_get_trained(gsf_splat_get_trainer(run->fixer))->count;
        p->psnr = mean.psnr;
        p->psnr_seen = mean.psnr_seen;
    }
    gsf_free(run->ctx, scores);
    return result;
}

static gsf_result load_masks(fix_run* run) {
    run->masks = (gsf_image*)gsf_alloc_zeroed(run->ctx, run->split.test_count + 1, sizeof *run->masks);
    if (!run->masks) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < run->split.test_count; i++) {
        const gsf_camera* camera = &run->scene.views[run->split.test[i]].camera;
        const gsfix_path path =
            gsfix_pathf("%s/%s.png", run->app->o.masks, gsfix_view_stem(&run->scene, run->split.test[i]).s);
        const gsf_result result = gsf_load_image(run->ctx, path.s, 1, run->masks + i);
        if (result != GSF_OK) return result;
        if (run->masks[i].width != camera->width || run->masks[i].height != camera->height)
            return gsf_fail(run->ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %lld x %lld, but the view is %d x %d", path.s,
                            (long long)run->masks[i].width, (long long)run->masks[i].height, (int)camera->width,
                            (int)camera->height);
    }
    return GSF_OK;
}

// ---- checkpoint ------------------------------------------------------------------

static double as_written(float value) { // the shortest decimal that reads back as this float
    char text[32];
    for (int digits = 1; digits < 10; digits++) {
        snprintf(text, sizeof text, "%.*g", digits, (double)value);
        if ((float)strtod(text, NULL) == value) break;
    }
    return strtod(text, NULL);
}

static size_t masked_photos(const fix_run* run) { // number of masked photos among those trained on or measured
    size_t count = 0;
    for (size_t i = 0; i < run->scene.view_count; i++) count += run->scene.views[i].weight.data != NULL;
    return count;
}

static gsf_result digest_adapters(fix_run* run) { // --lora FILE, or the file in a folder
    const char* path = run->app->o.lora;
    const size_t size = strlen(path), end = strlen(".safetensors");
    if (size > end && strcmp(path + size - end, ".safetensors") == 0) return gsfix_digest_input(run->app, path);
    return gsfix_digest_input(run->app, gsfix_pathf("%s/adapter_model.safetensors", path).s);
}

// All settings that affect the result, with defaults filled in: printed in metrics.json, and compared by --resume.
static void write_dit_switches(fix_run* run) {
    const gsf_nn_dit_desc dit = gsfix_dit_desc(run->app);
    const gsf_nn_sample_desc d = gsf_nn_resolve_sample_desc(&dit.sample);
    gsf_context* ctx = run->ctx;
    gsf_buffer* t = &run->switches;
    gsfix_json_text(ctx, t, "condition", gsfix_conditions[dit.condition]);
    gsfix_json_text(ctx, t, "ref_features", dit.features);
    gsfix_json_text(ctx, t, "lora", dit.lora);
    gsfix_json_text(ctx, t, "caption", dit.caption);
    gsfix_json_number(ctx, t, "steps", d.steps);
    gsfix_json_text(ctx, t, "solver", gsfix_solvers[d.solver]);
    gsfix_json_number(ctx, t, "guidance", as_written(d.guidance));
    gsfix_json_number(ctx, t, "guidance_until", as_written(d.guidance_end));
    gsfix_json_number(ctx, t, "strength", as_written(d.strength));
    gsfix_json_number(ctx, t, "block_cache", as_written(d.block_cache));
    gsfix_json_text(ctx, t, "int8", dit.int8 ? "on" : "off");
    gsfix_json_text(ctx, t, "bf16", dit.bf16 ? "on" : "off");
    gsfix_json_text(ctx, t, "any_frames", dit.sample.any_frames ? "on" : "off");
}

static void write_switches(fix_run* run) {
    gsf_context* ctx = run->ctx;
    gsf_buffer* t = &run->switches;
    const gsfix_options* o = &run->app->o;
    static const char* const kinds[] = {"reference", "ellipse", "interpolate", "spread"};
    const gsf_camera* first = &run->scene.views[run->split.train[0]].camera;
    gsfix_setup used = run->setup;
    used.fix = gsf_splat_get_fixer_desc(run->fixer);
    const gsf_train_desc* train = &used.fix.train;
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_number(ctx, t, "iterations", train->iterations);
    gsfix_json_number(ctx, t, "seed", (double)train->seed);
    gsfix_json_text(ctx, t, "restorer", o->restorer ? o->restorer : "none");
    if (o->restorer && strncmp(o->restorer, "dit:", 4) == 0) write_dit_switches(run);
    gsfix_json_text(ctx, t, "regularize", o->regularize ? o->regularize : "on");
    gsfix_json_text(ctx, t, "compare", o->compare ? "on" : "off");
    gsfix_json_text(ctx, t, "trajectory", run->path ? "given" : kinds[used.fix.trajectory]);
    gsfix_json_text(ctx, t, "init", initial_kinds[used.initial.kind]);
    gsfix_json_text(ctx, t, "quality", gsfix_find_quality(o->quality)->name);
    gsfix_json_text(ctx, t, "gradient", train->render.gradient == GSF_GRADIENT_TRUE ? "true" : "official");
    for (int i = 0; i < SETTING_COUNT; i++) {
        const void* field = (const char*)&used + settings[i].offset;
        if (strcmp(settings[i].name, "random_points") == 0 && used.initial.kind != GSF_INITIAL_RANDOM) continue;
        if (strncmp(settings[i].name, "dense_", 6) == 0 && used.initial.kind != GSF_INITIAL_DENSE) continue;
        const int kind = settings[i].kind;
        const int32_t whole = kind == SET_WHOLE || kind == SET_SWITCH ? *(const int32_t*)field : 0;
        if (kind == SET_COUNT) gsfix_json_number(ctx, t, settings[i].name, (double)*(const size_t*)field);
        else if (kind == SET_REAL) gsfix_json_number(ctx, t, settings[i].name, as_written(*(const float*)field));
        else if (kind == SET_WHOLE) gsfix_json_number(ctx, t, settings[i].name, whole);
        else gsfix_json_text(ctx, t, settings[i].name, whole ? "on" : "off");
    }
    gsfix_json_number(ctx, t, "extent", as_written(train->extent));
    gsfix_json_number(ctx, t, "near_plane", as_written(train->render.near_plane));
    if (train->background_kind == GSF_BACKGROUND_GIVEN) {
        gsfix_json_begin(ctx, t, "background", '[');
        for (int c = 0; c < 3; c++) gsfix_json_number(ctx, t, NULL, as_written(train->background[c]));
        gsfix_json_end(ctx, t, ']');
    } else { // of photos that have changed, --resume names the photo, not their grey
        gsfix_json_text(ctx, t, "background", train->background_kind == GSF_BACKGROUND_PHOTOS ? "photos" : "random");
    }
    gsfix_json_text(ctx, t, "photo_masks", o->photo_masks ? o->photo_masks : "on");
    gsfix_json_number(ctx, t, "photos_masked", (double)masked_photos(run));
    gsfix_json_text(ctx, t, "views", o->views ? o->views : "all");
    gsfix_json_number(ctx, t, "test_every", o->test_every ? o->test_every : 8);
    gsfix_json_number(ctx, t, "factor", o->factor ? o->factor : 1);
    gsfix_json_number(ctx, t, "max_size", o->max_size);
    gsfix_json_number(ctx, t, "width", first->width);
    gsfix_json_number(ctx, t, "height", first->height);
    gsfix_json_number(ctx, t, "initial_splats", (double)run->initial.count);
    gsfix_json_begin(ctx, t, "train_views", '[');
    for (size_t i = 0; i < run->split.train_count; i++)
        gsfix_json_text(ctx, t, NULL, run->scene.views[run->split.train[i]].name);
    gsfix_json_end(ctx, t, ']');
    gsfix_json_end(ctx, t, '}');
}

static void write_list(gsf_context* ctx, gsf_buffer* t, const char* key, const double* values, size_t count) {
    gsfix_json_begin(ctx, t, key, '[');
    for (size_t i = 0; i < count; i++) gsfix_json_number(ctx, t, NULL, values[i]);
    gsfix_json_end(ctx, t, ']');
}

static gsfix_path input_digest(const gsfix_read_file* file) {
    return gsfix_pathf("%016llx %llu", (unsigned long long)file->digest, (unsigned long long)file->size);
}

static void write_curve_rows(gsf_context* ctx, gsf_buffer* t, const char* key, const gsfix_curve_point* points,
                             size_t count) {
    gsfix_json_begin(ctx, t, key, '[');
    for (size_t i = 0; i < count; i++) {
        const double row[4] = {points[i].iteration, (double)points[i].splats, points[i].psnr, points[i].psnr_seen};
        write_list(ctx, t, NULL, row, 4);
    }
    gsfix_json_end(ctx, t, ']');
}

static void write_times(const fix_run* run, gsf_buffer* t) {
    write_list(run->ctx, t, "seconds", run->history.seconds, GSFIX_STAGES);
    gsfix_json_number(run->ctx, t, "seconds_total", run->total_before + gsfix_now() - run->app->started);
}

// The history as JSON: lists of numbers, so that each list is read back by one loop.
static void write_history(fix_run* run, gsf_buffer* t) {
    gsf_context* ctx = run->ctx;
    const gsfix_history* h = &run->history;
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_begin(ctx, t, "switches", '{');
    t->size--; // drop the brace; the object itself is appended
    gsf_append_bytes(ctx, t, run->switches.data, run->switches.size);
    gsfix_json_begin(ctx, t, "inputs", '[');
    for (size_t i = 0; i < run->input_count; i++) {
        gsfix_json_begin(ctx, t, NULL, '[');
        gsfix_json_text(ctx, t, NULL, run->inputs[i].path);
        gsfix_json_text(ctx, t, NULL, input_digest(run->inputs + i).s);
        gsfix_json_end(ctx, t, ']');
    }
    gsfix_json_end(ctx, t, ']');
    write_times(run, t);
    gsfix_json_number(ctx, t, "iteration", run->iteration);
    gsfix_json_number(ctx, t, "resumed", h->resumed);
    gsfix_json_number(ctx, t, "comparing", run->comparing);
    gsfix_json_begin(ctx, t, "without", '[');
    for (size_t i = 0; h->has_without && i < h->view_count; i++) write_list(ctx, t, NULL, &h->without[i].psnr, 4);
    gsfix_json_end(ctx, t, ']');
    write_curve_rows(ctx, t, "without_curve", h->without_curve, h->without_count);
    write_curve_rows(ctx, t, "curve", h->curve, h->curve_count);
    gsfix_json_begin(ctx, t, "rounds", '[');
    for (size_t i = 0; i < h->round_count; i++) {
        const gsfix_round* r = &h->rounds[i];
        const double row[6] = {r->round, r->iteration, r->windows, r->skipped, r->frames, r->confidence};
        write_list(ctx, t, NULL, row, 6);
    }
    gsfix_json_end(ctx, t, ']');
    gsfix_json_begin(ctx, t, "path", '[');
    for (size_t i = 0; i < h->path_count; i++) {
        const gsfix_flown* f = &h->path[i];
        const double row[9] = {f->round, f->window, f->reference, f->center[0], f->center[1], f->center[2],
                               f->forward[0], f->forward[1], f->forward[2]};
        write_list(ctx, t, NULL, row, 9);
    }
    gsfix_json_end(ctx, t, ']');
    gsfix_json_begin(ctx, t, "samples", '[');
    for (size_t i = 0; i < h->sample_count; i++) {
        const double row[3] = {h->samples[i].round, h->samples[i].window, h->samples[i].frame};
        write_list(ctx, t, NULL, row, 3);
    }
    gsfix_json_end(ctx, t, ']');
    gsfix_json_end(ctx, t, '}');
}

// Copies have a checkpoint of their own, so that the run's, complete by then, stays one of a run without them.
static const char* checkpoint_file(const fix_run* run) { return run->copy ? "copies/checkpoint" : "checkpoint"; }

static int joined_copies(const fix_run* run) { // how many are being joined
    return run->copy && run->copy == (int)copy_count(run) ? run->copy : 0;
}

static void write_copy(const fix_run* run, gsf_buffer* t) { // what the checkpoint of a copy says beside its state
    gsf_context* ctx = run->ctx;
    gsfix_json_begin(ctx, t, NULL, '{');
    write_times(run, t);
    gsfix_json_number(ctx, t, "iteration", run->iteration);
    gsfix_json_number(ctx, t, "copy", run->copy);
    gsfix_json_number(ctx, t, "joined", joined_copies(run));
    gsfix_json_end(ctx, t, '}');
}

static gsf_result save_checkpoint(fix_run* run) {
    gsf_context* ctx = run->ctx;
    gsf_buffer chunks = {0}, json = {0};
    const double begin = gsfix_now();
    if (run->copy) write_copy(run, &json);
    else write_history(run, &json);
    gsf_splat_format_fixer(ctx, run->fixer, &chunks);
    gsf_append_chunk(ctx, &chunks, "GFIX", json.data, json.size);
    gsf_append_last_chunk(ctx, &chunks);
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    if (!json.failed && !chunks.failed)
        result = gsf_write_file(ctx, gsfix_pathf("%s/%s", run->app->o.out, checkpoint_file(run)).s, chunks.data, chunks.size);
    gsf_destroy_buffer(ctx, &chunks);
    gsf_destroy_buffer(ctx, &json);
    run->checkpoint_end = gsfix_now();
    run->checkpoint_last = run->checkpoint_end - begin;
    run->checkpoint_sum += run->checkpoint_last;
    return result;
}

// Decides whether to write a checkpoint at a point where one may be written; the result of the run does not depend on it.
// Together with the next one and the last, which is always written, checkpoints take less than 2 % of the elapsed time.
// Within a round, whose frames take much memory, one is written at most every minute.
static int checkpoint_pays(const fix_run* run, int within_round) {
    const double now = gsfix_now();
    return now - run->checkpoint_end >= (within_round ? 60.0 : 1.0) &&
           run->checkpoint_sum + 2.0 * run->checkpoint_last <= 0.02 * (now - run->app->started);
}

static int same_json(const gsf_json* a, const gsf_json_value* x, const gsf_json* b, const gsf_json_value* y) {
    if (!x || !y || x->type != y->type || x->count != y->count) return 0;
    if (x->type == GSF_JSON_STRING) return strcmp(x->string, y->string) == 0;
    if (x->type == GSF_JSON_NUMBER) return x->number == y->number;
    for (size_t i = 0; i < x->count; i++)
        if (!same_json(a, gsf_find_json_element(a, x, i), b, gsf_find_json_element(b, y, i))) return 0;
    return 1;
}

static void show_json(const gsf_json_value* v, char text[128]) {
    if (v && v->type == GSF_JSON_STRING) snprintf(text, 128, "%.100s", v->string);
    else if (v && v->type == GSF_JSON_NUMBER) snprintf(text, 128, "%g", v->number);
    else snprintf(text, 128, v ? "others" : "none");
}

gsf_result gsfix_compare_settings(gsf_context* ctx, const char* name, const gsf_buffer* now, const gsf_json* old,
                                  const gsf_json_value* was) {
    gsf_json json;
    gsf_result result = gsf_parse_json(ctx, "settings", now->data, now->size, &json);
    if (result != GSF_OK) return result;
    for (uint32_t i = json.values[0].child; i && result == GSF_OK; i = json.values[i].next) {
        const gsf_json_value *x = &json.values[i], *y = gsf_find_json_member(old, was, x->key);
        char mine[128], theirs[128];
        if (same_json(&json, x, old, y)) continue;
        show_json(x, mine);
        show_json(y, theirs);
        result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: made with %s %s, now %s", name, x->key, theirs, mine);
    }
    gsf_destroy_json(ctx, &json);
    return result;
}

static gsf_result compare_switches(fix_run* run, const char* name, const gsf_json* old, const gsf_json_value* was) {
    return gsfix_compare_settings(run->ctx, name, &run->switches, old, was);
}

// Checks that every file read then and now has the same content; its path does not matter.
static gsf_result compare_inputs(fix_run* run, const char* name, const gsf_json* old, const gsf_json_value* was) {
    if (!was || was->type != GSF_JSON_ARRAY)
        return gsf_fail(run->ctx, GSF_ERROR_FORMAT, "%s: does not say what it was made from (--restart begins anew)", name);
    for (size_t i = 0; i < was->count || i < run->input_count; i++) {
        const gsf_json_value* row = i < was->count ? gsf_find_json_element(old, was, i) : NULL;
        const gsf_json_value* path = row ? gsf_find_json_element(old, row, 0) : NULL;
        const gsf_json_value* digest = row ? gsf_find_json_element(old, row, 1) : NULL;
        const int valid = path && digest && path->type == GSF_JSON_STRING && digest->type == GSF_JSON_STRING;
        if (row && !valid) return gsf_fail(run->ctx, GSF_ERROR_FORMAT, "%s: broken list of inputs", name);
        if (row && i < run->input_count && strcmp(digest->string, input_digest(run->inputs + i).s) == 0) continue;
        return gsf_fail(run->ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: made with another %s (--restart begins anew)", name,
                        i < run->input_count ? run->inputs[i].path : path->string);
    }
    return GSF_OK;
}

// NULL: missing or out of range.
static const gsf_json_value* whole_member(const gsf_json* json, const char* key, double most) {
    const gsf_json_value* v = gsf_find_json_member(json, &json->values[0], key);
    return v && v->type == GSF_JSON_NUMBER && v->number >= 0.0 && v->number <= most && v->number == floor(v->number) ? v : NULL;
}

// Reads the rows of a list in the history. kinds gives the type of each column: w = integer in 0..1e9, i = the same or -1,
// c = integer in 0..2^53, f = finite number, n = finite number or null (NaN).
static gsf_result read_rows(fix_run* run, const char* name, const gsf_json* json, const char* key, const char* kinds,
                            double** rows, size_t* count) {
    gsf_context* ctx = run->ctx;
    const gsf_json_value* list = gsf_find_json_member(json, &json->values[0], key);
    const size_t columns = strlen(kinds);
    *rows = NULL;
    *count = 0;
    int valid = list && list->type == GSF_JSON_ARRAY;
    if (valid && !list->count) return GSF_OK;
    double* values = valid ? (double*)gsf_alloc(ctx, list->count, columns * sizeof *values) : NULL;
    if (valid && !values) return GSF_ERROR_OUT_OF_MEMORY;
    for (uint32_t i = valid ? list->child : 0; i && valid; i = json->values[i].next, ++*count) {
        size_t k = 0;
        valid = json->values[i].type == GSF_JSON_ARRAY && json->values[i].count == columns;
        for (uint32_t at = valid ? json->values[i].child : 0; at && valid; at = json->values[at].next, k++) {
            const int is_number = json->values[at].type == GSF_JSON_NUMBER;
            const double x = is_number ? json->values[at].number : NAN;
            const double least = kinds[k] == 'i' ? -1.0 : 0.0, most = kinds[k] == 'c' ? 9007199254740992.0 : 1e9;
            if (kinds[k] == 'n' || kinds[k] == 'f') valid = isfinite(x) || (!is_number && kinds[k] == 'n');
            else valid = x >= least && x <= most && x == floor(x);
            values[*count * columns + k] = x;
        }
    }
    *rows = values;
    return valid ? GSF_OK : gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: \"%s\" holds what no run writes there", name, key);
}

static gsf_result take_row(fix_run* run, int list, const double* x) {
    gsf_context* ctx = run->ctx;
    gsfix_history* h = &run->history;
    gsf_result result = GSF_OK;
    if (list == 0) {
        const gsfix_curve_point p = {(int32_t)x[0], (uint64_t)x[1], x[2], x[3]};
        if ((result = GROW(ctx, h, curve, curve)) == GSF_OK) h->curve[h->curve_count++] = p;
    } else if (list == 1) {
        const gsfix_round p = {(int32_t)x[0], (int32_t)x[1], (int32_t)x[2], (int32_t)x[3], (int32_t)x[4], x[5]};
        if ((result = GROW(ctx, h, rounds, round)) == GSF_OK) h->rounds[h->round_count++] = p;
    } else if (list == 2) {
        const gsfix_flown p = {(int32_t)x[0], (int32_t)x[1], (int32_t)x[2], {x[3], x[4], x[5]}, {x[6], x[7], x[8]}};
        if ((result = GROW(ctx, h, path, path)) == GSF_OK) h->path[h->path_count++] = p;
    } else if (list == 3) {
        const gsfix_curve_point p = {(int32_t)x[0], (uint64_t)x[1], x[2], x[3]};
        if ((result = GROW(ctx, h, without_curve, without)) == GSF_OK) h->without_curve[h->without_count++] = p;
    } else {
        const gsfix_sample p = {(int32_t)x[0], (int32_t)x[1], (int32_t)x[2]};
        if ((result = GROW(ctx, h, samples, sample)) == GSF_OK) h->samples[h->sample_count++] = p;
    }
    return result;
}

static void read_times(fix_run* run, const gsf_json* json) { // in place of those read before
    const gsf_json_value* seconds = gsf_find_json_member(json, &json->values[0], "seconds");
    const gsf_json_value* total = gsf_find_json_member(json, &json->values[0], "seconds_total");
    for (size_t i = 0; i < GSFIX_STAGES; i++) {
        const gsf_json_value* s = gsf_find_json_element(json, seconds, i);
        if (!s || s->type != GSF_JSON_NUMBER || !isfinite(s->number)) continue;
        run->history.seconds[i] += s->number - run->seconds_before[i];
        run->seconds_before[i] = s->number;
    }
    if (total && total->type == GSF_JSON_NUMBER && isfinite(total->number)) run->total_before = total->number;
}

static gsf_result read_history(fix_run* run, const char* name, const gsf_json* json) {
    static const struct { const char *key, *kinds; } lists[] = {
        {"curve", "wcnn"}, {"rounds", "wwwwwf"}, {"path", "wwiffffff"}, {"without_curve", "wcnn"},
        {"samples", "www"}};
    gsf_context* ctx = run->ctx;
    gsfix_history* h = &run->history;
    const gsf_json_value* resumed = whole_member(json, "resumed", 1e9);
    const gsf_json_value* iteration = whole_member(json, "iteration", run->iterations);
    const gsf_json_value* comparing = whole_member(json, "comparing", run->app->o.compare);
    double* r = NULL;
    size_t n = 0;
    if (!resumed || !iteration || !comparing)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid number of steps or of earlier runs", name);
    h->resumed = (int32_t)resumed->number + (resumed->number < 1e9); // capped at the largest value that can be read back
    run->iteration = (int32_t)iteration->number;
    run->comparing = (int)comparing->number;
    read_times(run, json);
    gsf_result result = read_rows(run, name, json, "without", "nnnn", &r, &n);
    if (result == GSF_OK && n && n != h->view_count)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: \"without\" has %zu views, the scene %zu", name, n, h->view_count);
    for (size_t i = 0; i < n && result == GSF_OK; i++) memcpy(&h->without[i].psnr, r + 4 * i, 4 * sizeof *r);
    h->has_without = n > 0 && result == GSF_OK;
    if (result == GSF_OK && run->app->o.compare && run->comparing == h->has_without)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: neither with nor without the figures to compare to", name);
    gsf_free(ctx, r);
    for (int list = 0; list < 5 && result == GSF_OK; list++) {
        result = read_rows(run, name, json, lists[list].key, lists[list].kinds, &r, &n);
        for (size_t i = 0; i < n && result == GSF_OK; i++) result = take_row(run, list, r + i * strlen(lists[list].kinds));
        gsf_free(ctx, r);
    }
    return result;
}

// Reads the checkpoint and its JSON; the caller frees both, even after a failure.
static gsf_result open_checkpoint(fix_run* run, const char* name, void** data, size_t* size, gsf_json* json) {
    gsf_context* ctx = run->ctx;
    gsf_chunk chunk;
    gsf_result result = gsf_read_file(ctx, name, data, size);
    if (result == GSF_OK) result = gsf_check_chunks(ctx, name, *data, *size);
    if (result == GSF_OK && !gsf_find_chunk(*data, *size, "GFIX", &chunk))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: not a checkpoint of gsfix fix", name);
    if (result == GSF_OK) result = gsf_parse_json(ctx, name, (const char*)chunk.data, chunk.size, json);
    return result;
}

static gsf_fix_desc fixer_desc(const fix_run* run, int copy) {
    gsf_fix_desc desc = run->setup.fix;
    desc.points = run->scene.points; // they determine the up direction of the path
    desc.point_count = run->scene.point_count;
    desc.path = run->path;
    desc.path_count = run->path_count;
    desc.train.seed += (uint64_t)copy;
    return desc;
}

static gsf_result make_fixer(fix_run* run, const gsf_fix_desc* desc, const gsf_splats* initial, gsf_fixer** out) {
    const size_t n = run->split.train_count;
    gsf_train_view* views = NULL;
    gsf_result result = gsf_splat_load_train_views(run->ctx, &run->scene, run->split.train, n, &views);
    if (result != GSF_OK) return result;
    const int repairs = run->has_restorer && !run->comparing;
    result = gsf_splat_make_fixer(run->ctx, desc, views, n, initial, repairs ? &run->restorer : NULL, out);
    gsf_free(run->ctx, views);
    return result;
}

// Replaces the fixer by a new one.
static gsf_result start_fixer(fix_run* run) {
    const gsf_fix_desc desc = fixer_desc(run, 0);
    gsf_splat_destroy_fixer(run->ctx, run->fixer);
    run->fixer = NULL;
    return make_fixer(run, &desc, &run->initial, &run->fixer);
}

static gsf_result resume(fix_run* run) {
    gsf_context* ctx = run->ctx;
    const gsfix_path path = gsfix_pathf("%s/checkpoint", run->app->o.out);
    void* data = NULL;
    size_t size = 0;
    gsf_json json = {0};
    gsf_result result = open_checkpoint(run, path.s, &data, &size, &json);
    if (result == GSF_OK)
        result = compare_switches(run, path.s, &json, gsf_find_json_member(&json, &json.values[0], "switches"));
    if (result == GSF_OK)
        result = compare_inputs(run, path.s, &json, gsf_find_json_member(&json, &json.values[0], "inputs"));
    if (result == GSF_OK) result = read_history(run, path.s, &json);
    if (result == GSF_OK) result = start_fixer(run); // without the restorer if it was comparing
    if (result == GSF_OK) result = gsf_splat_parse_fixer(ctx, run->fixer, path.s, data, size);
    gsf_destroy_json(ctx, &json);
    gsf_free(ctx, data);
    return result;
}

// An existing checkpoint is continued or, with --restart, discarded; it is never silently replaced.
static gsf_result meet_checkpoint(fix_run* run) {
    gsf_context* ctx = run->ctx;
    const gsfix_options* o = &run->app->o;
    const gsfix_path path = gsfix_pathf("%s/checkpoint", o->out);
    void* data = NULL;
    size_t size = 0;
    gsf_json json = {0};
    if (!gsfix_has_output(run->app, "checkpoint") || o->restart) return GSF_OK;
    run->resuming = o->resume;
    if (o->resume) return GSF_OK;
    const gsf_result result = open_checkpoint(run, path.s, &data, &size, &json);
    const gsf_json_value* now = result == GSF_OK ? whole_member(&json, "iteration", 1e9) : NULL;
    const gsf_json_value* switches = now ? gsf_find_json_member(&json, &json.values[0], "switches") : NULL;
    const gsf_json_value* all = switches ? gsf_find_json_member(&json, switches, "iterations") : NULL;
    char step[64] = "";
    if (all && all->type == GSF_JSON_NUMBER) snprintf(step, sizeof step, " at step %.0f of %.0f", now->number, all->number);
    gsf_destroy_json(ctx, &json);
    gsf_free(ctx, data);
    return gsf_fail(ctx, GSF_ERROR_IO, "%s holds the checkpoint of a run%s: --resume goes on, --restart begins anew",
                    o->out, step);
}

// Training continues if a checkpoint cannot be written; the last good one stays in place.
static void keep_checkpoint(fix_run* run) {
#ifdef __GLIBC__
    malloc_trim(0); // what a round has freed; otherwise the checkpoint's buffer comes on top of it
#endif
    const gsf_result result = save_checkpoint(run);
    if (result != GSF_OK && !run->checkpoint_failed)
        gsfix_note(run->app, "warning: no checkpoint at step %d, going on without: %s", (int)run->iteration,
                   result == GSF_ERROR_OUT_OF_MEMORY ? "out of memory" : run->ctx->error);
    run->checkpoint_failed = result != GSF_OK;
    run->ctx->error[0] = 0;
}

// ---- the loop --------------------------------------------------------------------

// Claims every name that this run may write; others cannot be written.
static gsf_result open_fix_out(fix_run* run) {
    gsfix_app* app = run->app;
    static const char* const always[] = {"checkpoint", "dit.checkpoint", "splats.ply", "metrics.json", "report.html"};
    static const char* const repair[] = {"fixed/round*_window*_*.png", "report/round*_window*_*.png"};
    const size_t names = run->task ? 2 : sizeof always / sizeof *always; // for a task the checkpoints only
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < names && result == GSF_OK; i++) result = gsfix_claim(app, "%s", always[i]);
    for (int i = 0; i < ALSO_COUNT && result == GSF_OK; i++)
        if (wants_also(app, i)) result = gsfix_claim(app, "splats.%s", also_formats[i]);
    for (size_t i = 0; i < run->split.test_count && result == GSF_OK; i++) {
        const gsfix_path stem = gsfix_view_stem(&run->scene, run->split.test[i]);
        result = gsfix_claim(app, "test/%s.png", stem.s);
        if (result == GSF_OK && app->o.compare) result = gsfix_claim(app, "report/without/%s.png", stem.s);
        if (result == GSF_OK && app->o.filtered) result = gsfix_claim(app, "filtered/%s.png", stem.s);
    }
    for (int i = 0; i < app->o.copies && result == GSF_OK; i++) result = gsfix_claim(app, "%s", copy_file(i).s);
    if (result == GSF_OK && app->o.copies > 1) result = gsfix_claim(app, "copies/checkpoint");
    for (size_t i = 0; i < sizeof repair / sizeof *repair && result == GSF_OK && has_restorer(app) && !run->task; i++)
        result = gsfix_claim(app, "%s", repair[i]);
    if (result == GSF_OK && run->task) result = run->task->claim_fn(app, run->task->user);
    if (result == GSF_OK) result = gsfix_open_out(app);
    if (result == GSF_OK) result = gsfix_claim_file(app, app->o.save_features);
    return result == GSF_OK ? gsfix_claim_file(app, app->o.video) : result;
}

static gsf_result load_photos(fix_run* run) {
    gsf_result result = GSF_OK;
    for (int k = 0; k < 2; k++)
        for (size_t i = 0; i < (k ? run->split.test_count : run->split.train_count) && result == GSF_OK; i++)
            result = gsf_splat_load_view_image(run->ctx, &run->scene, k ? run->split.test[i] : run->split.train[i]);
    return result;
}

static gsf_result prepare(fix_run* run) {
    gsfix_app* app = run->app;
    gsf_context* ctx = run->ctx;
    gsf_result result = gsfix_load_scene(app, app->o.inputs[0], &run->scene);
    if (result == GSF_OK) result = gsfix_split_scene(app, &run->scene, &run->split);
    if (result == GSF_OK && app->o.compare && !run->split.test_count)
        result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "--compare: the scene has no held-out view to compare on");
    if (result == GSF_OK) gsfix_settle_train(&run->setup.fix.train, run->setup.initial.kind, run->split.train_count);
    if (result == GSF_OK) result = open_fix_out(run); // before any expensive work
    if (result == GSF_OK) result = meet_checkpoint(run);
    if (result == GSF_OK) result = gsfix_make_restorer(app, &run->restorer, &run->has_restorer);
    if (result == GSF_OK)
        run->setup.fix.train.render.near_plane =
            gsf_splat_measure_near_plane(&run->scene.views[0].camera, sizeof run->scene.views[0],
                                         run->scene.view_count);
    if (result == GSF_OK) result = load_photos(run);
    if (result == GSF_OK && app->o.masks) result = load_masks(run);
    if (result == GSF_OK && app->o.path) result = gsf_load_cameras(ctx, app->o.path, &run->path, &run->path_count);
    if (result == GSF_OK && app->o.path && !run->path_count)
        result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: no cameras", app->o.path);
    if (result == GSF_OK) result = gsfix_digest_input(app, app->o.ref_features);
    if (result == GSF_OK && app->o.lora) result = digest_adapters(run);
    if (result == GSF_OK) result = make_initial(run);
    if (result == GSF_OK) result = start_fixer(run);
    if (result != GSF_OK) return result;
    run->inputs = gsfix_end_inputs(app, &run->input_count);
    run->history.view_count = run->split.test_count;
    run->history.without = (gsfix_score*)gsf_alloc_zeroed(ctx, run->split.test_count + 1, sizeof *run->history.without);
    write_switches(run); // from the fixer with the restorer, if there is one
    if (!run->history.without || run->switches.failed) return GSF_ERROR_OUT_OF_MEMORY;
    run->comparing = app->o.compare;
    if (run->resuming) result = resume(run);
    else result = gsfix_remove_output(app, "checkpoint");
    for (int i = 0; i < app->o.copies && result == GSF_OK && !run->resuming; i++)
        result = gsfix_remove_output(app, copy_file(i).s); // of another run
    if (result == GSF_OK && !run->resuming && app->o.copies > 1) result = gsfix_remove_output(app, "copies/checkpoint");
    if (result == GSF_OK && !run->resuming && run->comparing) result = start_fixer(run);
    if (result == GSF_OK && !run->resuming) result = gsfix_remove_stale(app);
    if (result == GSF_OK) tell_start(run);
    return result;
}

// The frame shown in the report: a quarter into the window, where the camera leaves the photo it started from.
static gsf_result keep_sample(fix_run* run, const gsf_fix_stats* stats) {
    gsfix_history* h = &run->history;
    const int32_t i = stats->frame_count / 4;
    const gsf_image* const pictures[] = {stats->rendered + i, stats->restored + i, stats->confidence + i};
    static const char* const names[] = {"render", "restored", "confidence"};
    gsf_result result = GROW(run->ctx, h, samples, sample);
    for (int k = 0; k < 3 && result == GSF_OK; k++) {
        const gsfix_path path = gsfix_pathf("%s/report/round%d_window%d_%s.png", run->app->o.out, (int)stats->round,
                                            (int)stats->window, names[k]);
        result = gsf_save_image(run->ctx, path.s, pictures[k]);
    }
    if (result != GSF_OK) return result;
    const gsfix_sample sample = {stats->round, stats->window, i};
    h->samples[h->sample_count++] = sample;
    return GSF_OK;
}

static double mean_value(const gsf_image* image) { // of one channel
    double sum = 0.0;
    for (int64_t y = 0; y < image->height; y++)
        for (int64_t x = 0; x < image->width; x++)
            sum += *(const float*)(const void*)((const char*)image->data + y * image->stride_y + x * image->stride_x);
    return sum / ((double)image->width * (double)image->height);
}

static gsf_result save_window(fix_run* run, const gsf_fix_stats* stats) {
    gsfix_path* paths = (gsfix_path*)gsf_alloc(run->ctx, (size_t)stats->frame_count, sizeof *paths);
    if (!paths) return GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < stats->frame_count; i++)
        paths[i] = gsfix_pathf("%s/fixed/round%d_window%d_%05d.png", run->app->o.out, (int)stats->round,
                               (int)stats->window, (int)i);
    const gsf_result result = gsfix_save_images(run->ctx, paths, stats->restored, (size_t)stats->frame_count);
    gsf_free(run->ctx, paths);
    return result;
}

static gsf_result after_window(fix_run* run, const gsf_fix_stats* stats) {
    gsf_context* ctx = run->ctx;
    gsfix_history* h = &run->history;
    gsf_result result = GSF_OK;
    if (!h->round_count || h->rounds[h->round_count - 1].round != stats->round) {
        const gsfix_round fresh = {stats->round, run->iteration, 0, 0, 0, 0.0};
        result = GROW(ctx, h, rounds, round);
        if (result != GSF_OK) return result;
        h->rounds[h->round_count++] = fresh;
    }
    gsfix_round* round = &h->rounds[h->round_count - 1];
    round->windows++;
    round->skipped += !stats->restored;
    for (int32_t i = 0; i < stats->frame_count && result == GSF_OK; i++) {
        gsfix_flown flown;
        double c2w[16];
        gsf_get_camera_c2w(stats->cameras + i, c2w);
        flown.round = stats->round;
        flown.window = stats->window;
        flown.reference = stats->reference_index[i];
        memcpy(flown.center, c2w + 12, sizeof flown.center);
        memcpy(flown.forward, c2w + 8, sizeof flown.forward);
        result = GROW(ctx, h, path, path);
        if (result == GSF_OK) h->path[h->path_count++] = flown;
        if (result != GSF_OK || !stats->restored) continue;
        round->frames++;
        round->confidence += mean_value(stats->confidence + i);
    }
    if (result == GSF_OK && stats->restored && !run->task) result = save_window(run, stats);
    if (result == GSF_OK && stats->restored && !run->task) result = keep_sample(run, stats);
    return result;
}

static int32_t last_step(const fix_run* run) { return gsf_splat_get_fixer_desc(run->fixer).train.iterations; }

// Work due after a step: images, held-out scores, checkpoint. The step itself is already complete.
static gsf_result follow_step(fix_run* run, const gsf_fix_stats* stats, double* clock) {
    gsf_result result = GSF_OK;
    int due = 0;
    if (stats->stage == GSF_FIX_TRAIN) {
        run->iteration = stats->train.iteration;
        add_seconds(run, run->history.round_count ? GSFIX_DISTILL : GSFIX_TRAIN, clock);
        if (run->iteration % run->eval_every == 0 || run->iteration == last_step(run)) result = add_curve_point(run);
        add_seconds(run, GSFIX_RENDER, clock);
        due = run->iteration % run->checkpoint_every == 0;
    } else if (stats->stage == GSF_FIX_PLAN || stats->stage == GSF_FIX_RESTORE) {
        add_seconds(run, GSFIX_RESTORE, clock);
        result = add_curve_point(run);
        add_seconds(run, GSFIX_RENDER, clock);
        if (result == GSF_OK && stats->stage == GSF_FIX_RESTORE) {
            if (!run->copy) result = after_window(run, stats);
            due = 1;
        }
    }
    add_seconds(run, GSFIX_SAVE, clock);
    if (stats->stage == GSF_FIX_TRAIN && run->iteration == last_step(run)) due = 1;
    else if (due && !run->app->o.checkpoint_every) due = checkpoint_pays(run, stats->stage == GSF_FIX_RESTORE);
    if (result == GSF_OK && due) keep_checkpoint(run);
    add_seconds(run, GSFIX_CHECKPOINT, clock);
    return result;
}

static double all_steps(const fix_run* run) {
    const double n = run->iterations, copies = (double)copy_count(run);
    const double joining = copies > 1.0 ? fmax(1.0, floor(n / 8.0)) : 0.0; // as gsf_splat_make_fixer has it
    return n * ((run->app->o.compare ? 1.0 : 0.0) + copies) + joining;
}

static gsfix_path name_training(const fix_run* run) { // what is trained now, as a part of a line; nothing for the run itself
    if (run->comparing) return gsfix_pathf("without repair: ");
    if (joined_copies(run)) return gsfix_pathf("joining the copies: ");
    return run->copy ? gsfix_pathf("copy %d of %d: ", run->copy + 1, (int)copy_count(run)) : gsfix_pathf("%s", "");
}

static void show_step(fix_run* run, const gsf_fix_stats* stats) {
    const gsfix_history* h = &run->history;
    const double psnr = h->curve_count ? h->curve[h->curve_count - 1].psnr : NAN;
    char held_out[48] = "";
    if (!isnan(psnr) && !run->copy) snprintf(held_out, sizeof held_out, "  held-out %.2f dB", psnr);
    const double before = (double)run->iterations * ((run->app->o.compare && !run->comparing ? 1 : 0) + run->copy);
    const double done = before + run->iteration, all = all_steps(run);
    if (stats->stage == GSF_FIX_TRAIN)
        gsfix_progress(run->app, done, all, "%sstep %d of %d  loss %.4f  %zu splats%s", name_training(run).s,
                       (int)run->iteration, (int)last_step(run), stats->train.loss, stats->train.splats, held_out);
    else if (run->copy) return;
    else if (stats->stage == GSF_FIX_RESTORE && run->app->terminal)
        gsfix_progress(run->app, done, all, "round %d of %d: window %d of %d %s",
                       (int)stats->round, (int)stats->rounds, (int)stats->window, (int)stats->windows,
                       stats->restored ? "repaired" : "skipped");
    else if (stats->stage == GSF_FIX_RESTORE && stats->window == stats->windows)
        gsfix_note(run->app, "round %d of %d: %d windows, %d of them skipped%s", (int)stats->round, (int)stats->rounds,
                   (int)stats->windows, (int)h->rounds[h->round_count - 1].skipped, held_out);
}

static gsf_result run_loop(fix_run* run) {
    gsf_context* ctx = run->ctx;
    double clock = gsfix_now();
    gsf_result result = GSF_OK;
    run->checkpoint_end = clock;
    while (result == GSF_OK) {
        gsf_fix_stats stats;
        result = gsf_splat_step_fixer(ctx, run->fixer, &stats);
        if (result != GSF_OK || stats.stage == GSF_FIX_DONE) break;
        const int cancelled = gsf_is_cancelled(ctx); // the rest of the step is completed first
        gsf_clear_cancel(ctx);
        result = follow_step(run, &stats, &clock);
        if (cancelled) gsf_request_cancel(ctx);
        if (result == GSF_OK) show_step(run, &stats);
    }
    if (result != GSF_ERROR_CANCELLED) return result;
    gsf_clear_cancel(ctx);
    result = save_checkpoint(run);
    char why[sizeof ctx->error] = "out of memory";
    if (result != GSF_ERROR_OUT_OF_MEMORY) memcpy(why, ctx->error, sizeof why);
    const gsfix_path name = name_training(run);
    const int step = (int)run->iteration, last = (int)last_step(run);
    if (result != GSF_OK)
        return gsf_fail(ctx, result, "%sstopped at step %d of %d without a checkpoint%s: %.300s", name.s, step, last,
                        gsfix_has_output(run->app, checkpoint_file(run)) ? " (an older one stays)" : "", why);
    return gsf_fail(ctx, GSF_ERROR_CANCELLED, "%sstopped at step %d of %d; --resume goes on from %s/%s", name.s, step, last,
                    run->app->o.out, checkpoint_file(run));
}

// The run without repair is complete: keeps its scores and images, discards its splats.
static gsf_result end_comparison(fix_run* run) {
    gsfix_history* h = &run->history;
    double clock = gsfix_now();
    gsf_result result = evaluate(run, gsfix_pathf("%s/report/without", run->app->o.out).s, 1, h->without);
    if (result != GSF_OK) return result;
    add_seconds(run, GSFIX_COMPARE, &clock);
    h->has_without = 1;
    h->without_curve = h->curve;
    h->without_count = h->curve_count;
    h->without_room = h->curve_room;
    h->curve = NULL;
    h->curve_count = h->curve_room = 0;
    run->comparing = 0;
    run->iteration = 0;
    return start_fixer(run);
}

static gsf_result run_trainings(fix_run* run) {
    if (run->comparing) {
        gsf_result result = run_loop(run);
        if (result == GSF_OK) result = end_comparison(run);
        if (result != GSF_OK) return result;
    }
    return run_loop(run);
}

static gsf_result save_trained(fix_run* run, const char* file) { // the splats as they are now
    gsf_splats view = *gsf_splat_get_trained(gsf_splat_get_trainer(run->fixer));
    view.antialiased = run->setup.fix.train.render.antialiased;
    return gsf_splat_save(run->ctx, gsfix_pathf("%s/%s", run->app->o.out, file).s, &view, NULL);
}

// ---- copies ----------------------------------------------------------------------

// Trains a copy, or what joins them. The first that this process trains goes on from the checkpoint, if that is of it.
static gsf_result train_copy(fix_run* run) {
    gsf_context* ctx = run->ctx;
    const gsfix_path path = gsfix_pathf("%s/%s", run->app->o.out, checkpoint_file(run));
    void* data = NULL;
    size_t size = 0;
    gsf_json json = {0};
    run->iteration = 0;
    const int first = run->resuming && gsfix_has_output(run->app, checkpoint_file(run));
    run->resuming = 0;
    if (!first) return run_loop(run);
    gsf_result result = open_checkpoint(run, path.s, &data, &size, &json);
    const gsf_json_value* copy = result == GSF_OK ? whole_member(&json, "copy", GSFIX_COPIES_MOST) : NULL;
    const gsf_json_value* joined = result == GSF_OK ? whole_member(&json, "joined", GSFIX_COPIES_MOST) : NULL;
    const gsf_json_value* iteration = result == GSF_OK ? whole_member(&json, "iteration", last_step(run)) : NULL;
    if (result == GSF_OK && (!copy || !joined))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: does not tell of which copy it is", path.s);
    const int mine = result == GSF_OK && (int)copy->number == run->copy && (int)joined->number == joined_copies(run);
    if (mine && !iteration) result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no valid number of steps", path.s);
    if (mine && result == GSF_OK) run->iteration = (int32_t)iteration->number;
    if (mine && result == GSF_OK) result = gsf_splat_parse_fixer(ctx, run->fixer, path.s, data, size);
    if (result == GSF_OK) read_times(run, &json); // of what was done before it, too
    gsf_destroy_json(ctx, &json);
    gsf_free(ctx, data);
    return result == GSF_OK ? run_loop(run) : result;
}

// Trains a copy as a run with its seed would, and saves its splats.
static gsf_result make_copy(fix_run* run) {
    gsf_context* ctx = run->ctx;
    const gsf_fix_desc desc = fixer_desc(run, run->copy);
    gsf_initial_desc start = run->setup.initial;
    gsf_splats initial = {0};
    double clock = gsfix_now();
    start.seed += (uint64_t)run->copy;
    gsf_result result = gsf_splat_make_initial_splats(ctx, &run->scene, run->split.train, run->split.train_count, &start,
                                                      &initial, NULL);
    if (result == GSF_OK) result = make_fixer(run, &desc, &initial, &run->fixer);
    gsf_splat_destroy(ctx, &initial);
    add_seconds(run, GSFIX_COPIES, &clock);
    if (result == GSF_OK) result = train_copy(run);
    if (result == GSF_OK) result = save_trained(run, copy_file(run->copy).s);
    gsf_splat_destroy_fixer(ctx, run->fixer);
    run->fixer = NULL;
    return result;
}

// Makes the copies, but those that an interrupted run has left, and joins them to the run's splats.
static gsf_result join_copies(fix_run* run) {
    gsf_context* ctx = run->ctx;
    const int count = (int)copy_count(run);
    gsf_result result = save_trained(run, copy_file(0).s);
    run->copies[0] = run->fixer;
    run->fixer = NULL;
    for (run->copy = 1; run->copy < count && result == GSF_OK; run->copy++) {
        const gsfix_path file = copy_file(run->copy);
        const gsf_fix_desc desc = fixer_desc(run, run->copy);
        gsf_splats splats = {0};
        if (!gsfix_has_output(run->app, file.s)) result = make_copy(run);
        if (result == GSF_OK) result = gsf_splat_load(ctx, gsfix_pathf("%s/%s", run->app->o.out, file.s).s, &splats);
        if (result == GSF_OK) result = make_fixer(run, &desc, &splats, &run->copies[run->copy]);
        gsf_splat_destroy(ctx, &splats);
    }
    gsf_fix_desc desc = fixer_desc(run, 0);
    desc.copies = run->copies;
    desc.copy_count = (size_t)count;
    if (result == GSF_OK) result = make_fixer(run, &desc, NULL, &run->fixer);
    if (result == GSF_OK) result = train_copy(run);
    run->copy = 0;
    return result;
}

// ---- results ---------------------------------------------------------------------

static void write_scores(gsf_context* ctx, gsf_buffer* t, const char* suffix, const gsfix_score* s) {
    gsfix_json_number(ctx, t, gsfix_pathf("psnr%s", suffix).s, s->psnr);
    gsfix_json_number(ctx, t, gsfix_pathf("ssim%s", suffix).s, s->ssim);
    gsfix_json_number(ctx, t, gsfix_pathf("psnr_seen%s", suffix).s, s->psnr_seen);
    gsfix_json_number(ctx, t, gsfix_pathf("ssim_seen%s", suffix).s, s->ssim_seen);
}

static void write_views(fix_run* run, const gsfix_result* r, gsf_buffer* t) {
    gsf_context* ctx = run->ctx;
    gsfix_json_begin(ctx, t, "per_view", '[');
    for (size_t i = 0; i < run->split.test_count; i++) {
        gsfix_json_begin(ctx, t, NULL, '{');
        gsfix_json_text(ctx, t, "name", run->scene.views[run->split.test[i]].name);
        gsfix_json_text(ctx, t, "file", gsfix_pathf("test/%s.png", gsfix_view_stem(&run->scene, run->split.test[i]).s).s);
        write_scores(ctx, t, "", r->views + i);
        if (run->history.has_without) write_scores(ctx, t, "_without_repair", run->history.without + i);
        if (r->filtered_views) write_scores(ctx, t, "_filtered", r->filtered_views + i);
        gsfix_json_end(ctx, t, '}');
    }
    gsfix_json_end(ctx, t, ']');
}

static int window_frames(const gsfix_history* h, int32_t round) { // frames per window of a round, as given to the restorer
    int count = 0;
    for (size_t i = 0; i < h->path_count; i++) count += h->path[i].round == round && h->path[i].window == 1;
    return count;
}

static void write_curve(gsf_context* ctx, gsf_buffer* t, const char* key, const gsfix_curve_point* points,
                        size_t count) {
    gsfix_json_begin(ctx, t, key, '[');
    for (size_t i = 0; i < count; i++) {
        gsfix_json_begin(ctx, t, NULL, '{');
        gsfix_json_number(ctx, t, "iteration", points[i].iteration);
        gsfix_json_number(ctx, t, "splats", (double)points[i].splats);
        gsfix_json_number(ctx, t, "psnr", points[i].psnr);
        gsfix_json_number(ctx, t, "psnr_seen", points[i].psnr_seen);
        gsfix_json_end(ctx, t, '}');
    }
    gsfix_json_end(ctx, t, ']');
}

static void write_course(fix_run* run, gsf_buffer* t) { // rounds and curves
    gsf_context* ctx = run->ctx;
    const gsfix_history* h = &run->history;
    gsfix_json_begin(ctx, t, "rounds", '[');
    for (size_t i = 0; i < h->round_count; i++) {
        const gsfix_round* r = &h->rounds[i];
        gsfix_json_begin(ctx, t, NULL, '{');
        gsfix_json_number(ctx, t, "round", r->round);
        gsfix_json_number(ctx, t, "iteration", r->iteration);
        gsfix_json_number(ctx, t, "windows", r->windows);
        gsfix_json_number(ctx, t, "window_frames", window_frames(h, r->round));
        gsfix_json_number(ctx, t, "windows_skipped", r->skipped);
        gsfix_json_number(ctx, t, "frames_restored", r->frames);
        gsfix_json_number(ctx, t, "mean_confidence", r->frames ? r->confidence / r->frames : NAN);
        gsfix_json_end(ctx, t, '}');
    }
    gsfix_json_end(ctx, t, ']');
    write_curve(ctx, t, "curve", h->curve, h->curve_count);
    if (h->has_without) write_curve(ctx, t, "curve_without_repair", h->without_curve, h->without_count);
}

// Appends the members of metrics.json to app->json, which already has the opening brace.
static void write_metrics(fix_run* run, const gsfix_result* r) {
    gsf_context* ctx = run->ctx;
    gsf_buffer* t = &run->app->json;
    const gsfix_history* h = &run->history;
    gsfix_json_text(ctx, t, "version", GSF_VERSION);
    gsfix_json_text(ctx, t, "command", run->app->command_line);
    gsfix_json_text(ctx, t, "scene", run->scene.folder);
    write_scores(ctx, t, "", &r->mean);
    if (h->has_without) write_scores(ctx, t, "_without_repair", &r->without);
    if (r->copies > 1) {
        gsfix_json_number(ctx, t, "copies", (double)r->copies);
        gsfix_json_number(ctx, t, "psnr_first_copy", r->first_copy);
    }
    if (r->filtered_views) {
        gsfix_json_begin(ctx, t, "filtered", '{');
        write_scores(ctx, t, "", &r->filtered);
        gsfix_json_end(ctx, t, '}');
    }
    gsfix_json_text(ctx, t, "measured",
                    masked_photos(run) ? "float32 render clamped to [0,1] against the 8-bit photo, over the pixels that count "
                                         "at least half (alpha, masks), the others black in both; ssim as ssim_3dgs"
                                       : "float32 render clamped to [0,1] against the 8-bit photo; ssim as ssim_3dgs");
    write_views(run, r, t);
    gsfix_json_begin(ctx, t, "seconds", '{');
    gsfix_json_number(ctx, t, "total", h->seconds_total);
    for (int i = 0; i < GSFIX_STAGES; i++) gsfix_json_number(ctx, t, gsfix_stage_names[i], h->seconds[i]);
    gsfix_json_end(ctx, t, '}');
    gsfix_json_stages(run->app, t);
    gsfix_json_number(ctx, t, "photos_missing", (double)run->scene.missing_count);
    gsfix_json_number(ctx, t, "iterations", r->iterations);
    gsfix_json_number(ctx, t, "splats", (double)r->splats->count);
    gsfix_json_number(ctx, t, "peak_rss_bytes", (double)gsfix_peak_memory());
    gsfix_json_number(ctx, t, "seed", (double)run->app->o.seed);
    gsfix_json_number(ctx, t, "threads", ctx->parallel.worker_count);
    gsfix_json_text(ctx, t, "isa", gsf_describe_cpu_level(ctx->cpu_level));
    gsfix_json_text(ctx, t, "visibility_rays", run->rays);
    gsfix_json_number(ctx, t, "resumed", h->resumed);
    write_course(run, t);
    gsfix_json_begin(ctx, t, "switches", '{');
    t->size--;
    gsf_append_bytes(ctx, t, run->switches.data, run->switches.size);
}

static gsf_result save_metrics(fix_run* run) {
    gsf_buffer file = {0};
    gsf_append_bytes(run->ctx, &file, run->app->json.data, run->app->json.size);
    gsf_append_bytes(run->ctx, &file, "}\n", 2);
    const gsf_result result =
        file.failed || run->app->json.failed
            ? GSF_ERROR_OUT_OF_MEMORY
            : gsf_write_file(run->ctx, gsfix_pathf("%s/metrics.json", run->app->o.out).s, file.data, file.size);
    gsf_destroy_buffer(run->ctx, &file);
    return result;
}

static void print_results(fix_run* run, const gsfix_result* r) {
    gsfix_app* app = run->app;
    const gsfix_history* h = &run->history;
    const size_t missing = run->scene.missing_count;
    const double alone = r->copies > 1 ? r->first_copy : r->mean.psnr;
    if (missing)
        gsfix_print(app, "missing    %zu of %zu photos, so that views and held-out split differ from the complete scene",
                    missing, missing + run->scene.view_count);
    if (run->split.test_count) {
        gsfix_print(app, "held-out   PSNR %.3f dB  SSIM %.4f  (%zu views)", r->mean.psnr, r->mean.ssim,
                    run->split.test_count);
        if (run->masks) gsfix_print(app, "seen       PSNR %.3f dB  SSIM %.4f", r->mean.psnr_seen, r->mean.ssim_seen);
        if (r->copies > 1)
            gsfix_print(app, "one copy   PSNR %.3f dB  (the first of %zu, before they were joined)", r->first_copy, r->copies);
        if (h->has_without)
            gsfix_print(app, "no repair  PSNR %.3f dB  SSIM %.4f  (same number of steps; repair%s alone: %+.3f dB)",
                        r->without.psnr, r->without.ssim, r->copies > 1 ? " of one copy" : "", alone - r->without.psnr);
        if (r->filtered_views)
            gsfix_print(app, "filtered   PSNR %.3f dB  SSIM %.4f  (the same renders%s, cleaned up by the restorer)",
                        r->filtered.psnr, r->filtered.ssim, r->copies > 1 ? " and those of the copies" : "");
    }
    gsfix_print(app, "splats     %zu after %d steps, %.1f s, %.0f MB at the peak", r->splats->count, (int)r->iterations,
                h->seconds_total, (double)gsfix_peak_memory() / 1e6);
    gsfix_print_stages(app);
    char also[64] = "";
    for (int i = 0; i < ALSO_COUNT; i++)
        if (wants_also(app, i)) snprintf(also + strlen(also), sizeof also - strlen(also), "  splats.%s", also_formats[i]);
    gsfix_print(app, "wrote      %s/report.html  splats.ply%s  metrics.json  test/%s%s%s", app->o.out, also,
                h->round_count ? "  fixed/" : "", r->filtered_views ? "  filtered/" : "", r->copies > 1 ? "  copies/" : "");
}

static gsf_result save_splats(fix_run* run) {
    gsf_result result = save_trained(run, "splats.ply");
    for (int i = 0; i < ALSO_COUNT && result == GSF_OK; i++)
        if (wants_also(run->app, i)) result = save_trained(run, gsfix_pathf("splats.%s", also_formats[i]).s);
    return result;
}

// The repaired frames, from their files: those of an interrupted run are among them. Their sizes are looked at first.
static gsf_result save_fixed_video(fix_run* run) {
    gsf_context* ctx = run->ctx;
    const gsfix_history* h = &run->history;
    gsfix_video* video = NULL;
    int64_t width = 0, height = 0;
    size_t count = 0;
    gsf_result result = GSF_OK;
    for (int pass = 0; pass < 2 && result == GSF_OK; pass++) {
        int32_t frame = 0;
        if (pass) result = gsfix_begin_video(run->app, width, height, count, &video);
        for (size_t i = 0; i < h->path_count && result == GSF_OK; i++) {
            const gsfix_flown* flown = &h->path[i];
            gsf_image image = {0};
            frame = i && flown[-1].round == flown->round && flown[-1].window == flown->window ? frame + 1 : 0;
            const gsfix_path name = gsfix_pathf("fixed/round%d_window%d_%05d.png", (int)flown->round, (int)flown->window,
                                                (int)frame);
            if (!gsfix_has_output(run->app, name.s)) continue; // of a window that was left as it is
            result = gsf_load_image(ctx, gsfix_pathf("%s/%s", run->app->o.out, name.s).s, 3, &image);
            if (image.width > width) width = image.width;
            if (image.height > height) height = image.height;
            if (result == GSF_OK && pass) result = gsfix_add_frame(video, &image);
            if (result == GSF_OK && gsf_is_cancelled(ctx)) result = gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled");
            count++;
            gsf_destroy_image(ctx, &image);
        }
    }
    if (result == GSF_OK) result = gsfix_finish_video(video);
    gsfix_destroy_video(video);
    return result;
}

static gsf_result finish(fix_run* run) {
    gsf_context* ctx = run->ctx;
    gsfix_history* h = &run->history;
    const char* out = run->app->o.out;
    double clock = gsfix_now();
    gsfix_result r = {0};
    const size_t tests = run->split.test_count;
    gsfix_score* views = (gsfix_score*)gsf_alloc_zeroed(ctx, 2 * tests + 1, sizeof *views);
    if (!views) return GSF_ERROR_OUT_OF_MEMORY;
    r.scene = &run->scene;
    r.split = &run->split;
    r.history = h;
    r.out = out;
    r.switches = run->switches.data;
    r.masks = run->masks;
    r.views = views;
    r.iterations = run->iterations;
    r.copies = copy_count(run);
    r.first_copy = h->curve_count ? h->curve[h->curve_count - 1].psnr : NAN;
    r.splats = gsf_splat_get_trained(gsf_splat_get_trainer(run->fixer));
    r.render = run->setup.fix.train.render;
    gsf_result result = run->task ? GSF_OK : save_splats(run);
    add_seconds(run, GSFIX_SAVE, &clock);
    if (result == GSF_OK) result = evaluate(run, gsfix_pathf("%s/test", out).s, 1, views);
    add_seconds(run, GSFIX_RENDER, &clock);
    r.mean = mean_score(views, tests);
    if (run->app->o.filtered && tests) {
        if (result == GSF_OK) result = evaluate_filtered(run, views + tests);
        r.filtered_views = views + tests;
        r.filtered = mean_score(views + tests, tests);
        add_seconds(run, GSFIX_RESTORE, &clock);
    }
    r.without = mean_score(h->without, h->has_without ? run->split.test_count : 0);
    h->seconds_total = run->total_before + gsfix_now() - run->app->started;
    if (result == GSF_OK && run->task) {
        result = run->task->finish_fn(run->app, &r, run->task->user);
    } else if (result == GSF_OK) {
        write_metrics(run, &r);
        result = save_metrics(run);
        if (result == GSF_OK) result = gsfix_write_report(run->app, &r);
        if (result == GSF_OK && run->app->o.video) result = save_fixed_video(run);
        if (result == GSF_OK) print_results(run, &r);
    }
    gsf_free(ctx, views);
    return result;
}

static void free_run(fix_run* run) {
    gsf_context* ctx = run->ctx;
    gsf_splat_destroy_fixer(ctx, run->fixer);
    for (int i = 0; i < GSFIX_COPIES_MOST; i++) gsf_splat_destroy_fixer(ctx, run->copies[i]);
    gsf_destroy_restorer(run->ctx, &run->restorer);
    gsf_splat_destroy(ctx, &run->initial);
    for (size_t i = 0; run->masks && i < run->split.test_count; i++) gsf_destroy_image(ctx, run->masks + i);
    gsf_free(ctx, run->masks);
    gsf_free(ctx, run->path);
    gsfix_free_split(run->app, &run->split);
    gsf_splat_destroy_scene(ctx, &run->scene);
    gsf_destroy_buffer(ctx, &run->switches);
    gsf_free(ctx, run->history.without);
    gsf_free(ctx, run->history.without_curve);
    gsf_free(ctx, run->history.curve);
    gsf_free(ctx, run->history.rounds);
    gsf_free(ctx, run->history.path);
    gsf_free(ctx, run->history.samples);
}

gsf_result gsfix_fix_scene(gsfix_app* app, const gsfix_setup* setup, const gsfix_fix_task* task) {
    static const fix_run zero;
    fix_run run = zero;
    run.app = app;
    run.ctx = &app->ctx;
    run.task = task;
    run.setup = *setup;
    run.iterations = run.setup.fix.train.iterations;
    run.eval_every = app->o.eval_every ? app->o.eval_every : run.iterations / 10 > 0 ? run.iterations / 10 : 1;
    run.checkpoint_every = app->o.checkpoint_every   ? app->o.checkpoint_every
                           : run.iterations / 20 > 0 ? run.iterations / 20
                                                     : 1;
    gsf_result result = prepare(&run);
    run.history.seconds[GSFIX_INIT] += gsfix_now() - app->started;
    if (result == GSF_OK) result = run_trainings(&run);
    if (result == GSF_OK && copy_count(&run) > 1) result = join_copies(&run);
    if (result == GSF_OK) result = finish(&run);
    if (result == GSF_OK) result = gsfix_drop_dit_checkpoint(app);
    free_run(&run);
    return result;
}

int gsfix_run_fix(gsfix_app* app) {
    gsfix_setup setup;
    int code = gsfix_resolve_setup(app, &setup);
    if (code == 0 && app->o.video && (!app->o.restorer || strcmp(app->o.restorer, "none") == 0))
        return gsfix_misused(app, "--video: shows what a --restorer repairs, and there is none (see gsfix render --video)");
    if (code == 0) code = gsfix_check_video(app);
    if (code) return code;
    return gsfix_fix_scene(app, &setup, NULL) == GSF_OK ? 0 : gsfix_failed(app);
}
