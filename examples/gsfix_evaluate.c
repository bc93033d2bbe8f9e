// gsfix_evaluate.c - the command evaluate: the experiments of the paper, as tables and as a gallery
// SPDX-License-Identifier: MIT
#include "gsfix_evaluate.h"

#include <math.h>

/* Each run is a task with a folder of its own and runs the code of gsfix fix, dataset and restore:
       SCENE.kK.START.ARM.TRAJECTORY.sSEED   gsfix fix: trains on K photos, renders the held-out ones
           test/NAME.png, result.json; of the first seed pictures/00.jpg ..., the capture's cameras for the gallery
       SCENE.artifacts.kK.sSEED              gsfix dataset: sequences of artifact and clean frames
       SCENE.restored.ARM[.CONDITION].sSEED  restores these sequences (ARM artifacts: only measures them)
           sequence_00/frame_00001.png ..., result.json
   OUT itself gets tables.md, tables.tex, tables.csv, runs.csv and gallery.html, from what these folders hold. They do not
   depend on the order of the runs, on interruptions or on time, so that they are the same bytes whoever did the tasks.
   A run is finished if its result.json was made with the present settings and no checkpoint is beside it. */

const eval_score eval_scores[EVAL_SCORES] = {
    {"psnr", "PSNR", 2, 0, 0},
    {"ssim_3dgs", "SSIM", 3, 0, 0},
    {"lpips_vgg_raw", "LPIPS", 3, 1, 0}, // published figures feed the VGG network images in [0,1]
    {"i2v_subject", "I2V_SC", 4, 0, 1},
    {"i2v_background", "I2V_BC", 4, 0, 1},
    {"overall_consistency", "OC", 4, 0, 1},
    {"temporal_flickering", "TF", 4, 0, 1},
    {"motion_smoothness", "MS", 4, 0, 1},
};
enum { EVAL_PAIR_SCORES = 3 }; // PSNR, SSIM, LPIPS: of reconstructions only these

// ---- plan --------------------------------------------------------------------------

static const char* const eval_tables[] = {"restoration", "reconstruction", "conditions", "trajectories"};
static const char* const eval_trajectories[] = {"interpolate", "ellipse", "reference"}; // in the paper's order
static const char* const eval_conditions[] = {"none", "2d", "3d", "both"};
static const char* const eval_inits[] = {"tracks", "default", "embree", "both", "all", "dense", "random"};

// Splits text at its commas in place. choices: what items may be (choice_count of them); 0: anything.
static int eval_split(gsfix_app* app, const char* option, char* text, const char* const* choices, int choice_count,
                      eval_list* out) {
    out->count = 0;
    for (char* p = text; p;) {
        char* comma = strchr(p, ',');
        int known = !choice_count;
        if (comma) *comma = 0;
        for (int i = 0; i < choice_count; i++) known |= strcmp(choices[i], p) == 0;
        if (!known || !*p) return gsfix_misused(app, "%s: no \"%s\"", option, p);
        for (int i = 0; i < out->count; i++)
            if (strcmp(out->items[i], p) == 0) return gsfix_misused(app, "%s: %s stands there twice", option, p);
        if (out->count == EVAL_LIST) return gsfix_misused(app, "%s: more than %d", option, EVAL_LIST);
        out->items[out->count++] = p;
        p = comma ? comma + 1 : NULL;
    }
    return 0;
}

static int eval_index(const eval_list* list, const char* item) { // 0 if it is not there
    for (int i = 0; i < list->count; i++)
        if (strcmp(list->items[i], item) == 0) return i;
    return 0;
}

static int eval_is_dit(const eval_arm* arm) { return arm->restorer && strncmp(arm->restorer, "dit:", 4) == 0; }

static void eval_name_arms(eval_plan* plan, const eval_list* restorers) {
    for (int i = 0; i < restorers->count; i++) {
        eval_arm* arm = &plan->arms[plan->arm_count++];
        const char* r = restorers->items[i];
        const int n = (int)strcspn(r, ":"), shown = n < 20 ? n : 20;
        int same = 0;
        arm->plain = strcmp(r, "plain") == 0;
        arm->restorer = arm->plain || strcmp(r, "none") == 0 ? NULL : r;
        for (int k = 0; k < i; k++)
            same += (int)strcspn(restorers->items[k], ":") == n && strncmp(restorers->items[k], r, (size_t)n) == 0;
        if (same) snprintf(arm->name, sizeof arm->name, "%.*s-%d", shown, r, same + 1);
        else snprintf(arm->name, sizeof arm->name, "%.*s", shown, r);
    }
    plan->artifacts = plan->arm_count;
    snprintf(plan->arms[plan->artifacts].name, sizeof plan->arms->name, "artifacts");
}

static int eval_parse_metrics(gsfix_app* app, eval_plan* plan, char* text) {
    eval_list chosen = {{NULL}, 0};
    const char* names[EVAL_SCORES];
    for (int s = 0; s < EVAL_SCORES; s++) names[s] = eval_scores[s].metric;
    const int code = text ? eval_split(app, "--which", text, names, EVAL_SCORES, &chosen) : 0;
    if (code) return code;
    for (int s = 0; s < EVAL_SCORES; s++) {
        const int net = s >= 2 && strcmp(names[s], "temporal_flickering") != 0;
        int wanted = s < 2 || (!text && (!net || plan->given.models));
        for (int i = 0; i < chosen.count; i++) wanted |= strcmp(chosen.items[i], names[s]) == 0;
        if (!wanted) continue;
        if (net && !plan->given.models) return gsfix_misused(app, "%s needs --models", names[s]);
        if (strcmp(names[s], "overall_consistency") == 0 && !plan->given.caption) {
            if (!text) continue;
            return gsfix_misused(app, "%s needs --caption", names[s]);
        }
        snprintf(plan->which + strlen(plan->which), sizeof plan->which - strlen(plan->which), "%s%s", s ? "," : "", names[s]);
    }
    return 0;
}

static int eval_choose_tables(gsfix_app* app, eval_plan* plan, char* text) {
    eval_list chosen;
    int repairs = 0, models = 0;
    for (int i = 0; i < plan->arm_count; i++) {
        repairs += plan->arms[i].restorer != NULL;
        models += eval_is_dit(&plan->arms[i]);
    }
    const int possible = EVAL_TABLE_RESTORATION | EVAL_TABLE_RECONSTRUCTION |
                         (plan->conditions.count > 1 && models ? EVAL_TABLE_CONDITIONS : 0) |
                         (plan->trajectories.count > 1 && repairs ? EVAL_TABLE_TRAJECTORIES : 0);
    if (plan->conditions.count > 1 && !models)
        return gsfix_misused(app, "--conditions: none of --restorers is dit:MODEL_DIR");
    if (plan->trajectories.count > 1 && !repairs)
        return gsfix_misused(app, "--trajectories: none of --restorers repairs anything");
    plan->tables = possible;
    if (!text) return 0;
    const int code = eval_split(app, "--tables", text, eval_tables, 4, &chosen);
    if (code) return code;
    plan->tables = 0;
    for (int t = 0; t < 4; t++)
        for (int i = 0; i < chosen.count; i++)
            if (strcmp(eval_tables[t], chosen.items[i]) == 0) plan->tables |= 1 << t;
    if (plan->tables & ~possible)
        return gsfix_misused(app, plan->tables & ~possible & EVAL_TABLE_CONDITIONS
                                      ? "--tables conditions: compares several --conditions of the restorer dit"
                                      : "--tables trajectories: compares several --trajectories of a restorer");
    return 0;
}

static int eval_parse(gsfix_app* app, eval_plan* plan) { // 0 or an exit code
    const gsfix_options* o = &plan->given;
    const char* const given[] = {o->restorers ? o->restorers : "plain,none,warp",
                                 o->trajectories ? o->trajectories : "reference", o->inits ? o->inits : "tracks",
                                 o->conditions ? o->conditions : "both", o->tables ? o->tables : "", o->which ? o->which : ""};
    enum { LISTS = sizeof given / sizeof *given };
    eval_list restorers;
    char* texts[LISTS];
    size_t size = 0;
    for (int i = 0; i < LISTS; i++) size += strlen(given[i]) + 1;
    plan->texts = (char*)gsf_alloc(&app->ctx, size, 1);
    if (!plan->texts) return gsfix_failed(app);
    for (int i = 0; i < LISTS; i++) {
        texts[i] = i ? texts[i - 1] + strlen(given[i - 1]) + 1 : plan->texts;
        memcpy(texts[i], given[i], strlen(given[i]) + 1);
    }
    int code = gsfix_parse_views(app, o->views ? o->views : "3,6,9", plan->views, &plan->view_counts);
    if (!code) code = eval_split(app, "--restorers", texts[0], NULL, 0, &restorers);
    if (!code) code = eval_split(app, "--trajectories", texts[1], eval_trajectories, 3, &plan->trajectories);
    if (!code) code = eval_split(app, "--inits", texts[2], eval_inits, sizeof eval_inits / sizeof *eval_inits, &plan->inits);
    if (!code) code = eval_split(app, "--conditions", texts[3], eval_conditions, 4, &plan->conditions);
    if (code) return code;
    eval_name_arms(plan, &restorers);
    code = eval_choose_tables(app, plan, o->tables ? texts[4] : NULL);
    if (!code) code = eval_parse_metrics(app, plan, o->which ? texts[5] : NULL);
    plan->main_trajectory = eval_index(&plan->trajectories, "reference");
    plan->main_condition = eval_index(&plan->conditions, "both");
    return code;
}

// ---- runs --------------------------------------------------------------------------

static gsf_result eval_add(gsfix_app* app, eval_plan* plan, const eval_run* run, size_t needs, size_t* room) {
    gsf_context* ctx = &app->ctx;
    size_t rooms[3] = {*room, *room, *room};
    gsf_result result = gsfix_grow(ctx, (void**)&plan->runs, &rooms[0], plan->run_count, sizeof *plan->runs);
    if (result == GSF_OK) result = gsfix_grow(ctx, (void**)&plan->names, &rooms[1], plan->run_count, sizeof *plan->names);
    if (result == GSF_OK) result = gsfix_grow(ctx, (void**)&plan->needs, &rooms[2], plan->run_count, sizeof *plan->needs);
    if (result != GSF_OK) return result;
    *room = rooms[0];
    const char *scene = plan->scenes[run->scene], *arm = run->arm >= 0 ? plan->arms[run->arm].name : "";
    gsfix_path name;
    if (run->kind == EVAL_RECONSTRUCTION)
        name = gsfix_pathf("%s.k%d.%s.%s%s%s.s%d", scene, run->views, plan->inits.items[run->init], arm,
                           run->trajectory >= 0 ? "." : "",
                           run->trajectory >= 0 ? plan->trajectories.items[run->trajectory] : "", run->seed);
    else if (run->kind == EVAL_ARTIFACTS) name = gsfix_pathf("%s.artifacts.k%d.s%d", scene, run->views, run->seed);
    else
        name = gsfix_pathf("%s.restored.%s%s%s.s%d", scene, arm, run->condition >= 0 ? "." : "",
                           run->condition >= 0 ? plan->conditions.items[run->condition] : "", run->seed);
    plan->names[plan->run_count] = gsfix_copy_text(ctx, name.s, strlen(name.s));
    if (!plan->names[plan->run_count]) return GSF_ERROR_OUT_OF_MEMORY;
    plan->runs[plan->run_count] = *run;
    plan->needs[plan->run_count] = needs == SIZE_MAX ? plan->run_count : needs;
    plan->run_count++;
    return GSF_OK;
}

// All trainings of a scene and seed. The trajectories are compared with the fewest views, as in the paper.
static gsf_result eval_add_reconstructions(gsfix_app* app, eval_plan* plan, eval_run run, size_t* room) {
    gsf_result result = GSF_OK;
    run.kind = EVAL_RECONSTRUCTION;
    for (int k = 0; k < plan->view_counts; k++)
        for (run.init = 0; run.init < plan->inits.count; run.init++)
            for (run.arm = 0; run.arm < plan->arm_count; run.arm++)
                for (int t = 0; t < plan->trajectories.count && result == GSF_OK; t++) {
                    const int repairs = plan->arms[run.arm].restorer != NULL, is_main = t == plan->main_trajectory;
                    const int compared = repairs && k == 0 && plan->tables & EVAL_TABLE_TRAJECTORIES;
                    if (!compared && !(is_main && plan->tables & EVAL_TABLE_RECONSTRUCTION)) continue;
                    run.views = plan->views[k];
                    run.trajectory = repairs ? t : -1;
                    run.condition = eval_is_dit(&plan->arms[run.arm]) ? plan->main_condition : -1;
                    result = eval_add(app, plan, &run, SIZE_MAX, room);
                }
    return result;
}

static gsf_result eval_add_restorations(gsfix_app* app, eval_plan* plan, eval_run run, size_t* room) {
    const size_t artifacts = plan->run_count;
    run.kind = EVAL_ARTIFACTS;
    run.views = plan->views[0];
    run.init = run.arm = run.trajectory = run.condition = -1;
    gsf_result result = eval_add(app, plan, &run, SIZE_MAX, room);
    run.kind = EVAL_RESTORATION;
    for (run.arm = plan->artifacts; run.arm >= 0 && result == GSF_OK; run.arm--) {
        const int dit = eval_is_dit(&plan->arms[run.arm]);
        if (run.arm != plan->artifacts && !plan->arms[run.arm].restorer) continue;
        for (int c = 0; c < (dit ? plan->conditions.count : 1) && result == GSF_OK; c++) {
            if (dit && c != plan->main_condition && !(plan->tables & EVAL_TABLE_CONDITIONS)) continue;
            run.condition = dit ? c : -1;
            result = eval_add(app, plan, &run, artifacts, room);
        }
    }
    return result;
}

static gsf_result eval_list_runs(gsfix_app* app, eval_plan* plan) {
    const int seeds = plan->given.seeds ? plan->given.seeds : 1;
    size_t room = 0;
    eval_run run;
    gsf_result result = GSF_OK;
    memset(&run, 0, sizeof run);
    for (int i = 0; i < EVAL_SCORES; i++) run.scores[i] = NAN;
    for (run.scene = 0; run.scene < plan->scene_count; run.scene++)
        for (run.seed = 0; run.seed < seeds && result == GSF_OK; run.seed++) {
            if (plan->tables & (EVAL_TABLE_RESTORATION | EVAL_TABLE_CONDITIONS))
                result = eval_add_restorations(app, plan, run, &room);
            if (result == GSF_OK && plan->tables & (EVAL_TABLE_RECONSTRUCTION | EVAL_TABLE_TRAJECTORIES))
                result = eval_add_reconstructions(app, plan, run, &room);
        }
    return result;
}

const eval_run* eval_find(const eval_plan* plan, const eval_run* like, int scene, int seed) {
    const size_t seeds = plan->given.seeds ? (size_t)plan->given.seeds : 1;
    const size_t each = plan->run_count / ((size_t)plan->scene_count * seeds); // runs of a scene and seed, which stand together
    const eval_run* first = plan->runs + each * ((size_t)scene * seeds + (size_t)seed);
    for (const eval_run* r = first; r < first + each; r++)
        if (r->kind == like->kind && r->views == like->views && r->init == like->init && r->arm == like->arm &&
            r->trajectory == like->trajectory && r->condition == like->condition)
            return r;
    return NULL;
}

// ---- settings of a run ----------------------------------------------------------------

typedef struct eval_job { // a task at work
    gsfix_app* app;
    const eval_plan* plan;
    const eval_run* run;
    const char* name;
    gsfix_options before;  // the options that eval_begin has replaced
    const char* input;
    char views[16];
    gsfix_setup setup;
    gsf_buffer settings;   // JSON object without the closing brace: what determines the result, apart from the inputs
} eval_job;

// The command line that the run is equivalent to, in app->o.
static void eval_set_options(eval_job* job) {
    const eval_plan* plan = job->plan;
    const eval_run* run = job->run;
    gsfix_options* o = &job->app->o;
    const eval_arm* arm = run->arm >= 0 ? &plan->arms[run->arm] : &plan->arms[plan->artifacts];
    const char* init = run->init >= 0 ? plan->inits.items[run->init] : "tracks";
    snprintf(job->views, sizeof job->views, "%d", run->views);
    job->input = plan->given.inputs[run->scene];
    o->inputs = &job->input;
    o->input_count = 1;
    o->views = job->views;
    o->seed = plan->given.seed + (uint64_t)run->seed;
    o->init = strcmp(init, "default") == 0 ? NULL : init;
    o->restorer = arm->restorer;
    o->regularize = arm->plain || run->kind != EVAL_RECONSTRUCTION ? "off" : "on";
    o->trajectory = run->trajectory >= 0 ? plan->trajectories.items[run->trajectory] : NULL;
    o->condition = run->condition >= 0 ? plan->conditions.items[run->condition] : NULL;
    if (eval_is_dit(arm)) return;
    o->solver = NULL;
    o->steps = o->int8 = o->bf16 = o->any_frames = 0;
    o->guidance = o->guidance_until = o->strength = o->block_cache = 0.0;
    if (run->kind != EVAL_ARTIFACTS) o->caption = NULL;
}

static void eval_write_settings(eval_job* job) {
    gsf_context* ctx = &job->app->ctx;
    const gsfix_options* o = &job->app->o;
    gsf_buffer* t = &job->settings;
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "version", GSF_VERSION);
    gsfix_json_text(ctx, t, "scene", job->plan->scenes[job->run->scene]);
    gsfix_json_text(ctx, t, "views", o->views);
    gsfix_json_text(ctx, t, "start", o->init ? o->init : "default");
    gsfix_json_text(ctx, t, "restorer", o->restorer ? o->restorer : "none");
    gsfix_json_text(ctx, t, "regularize", o->regularize);
    gsfix_json_text(ctx, t, "trajectory", o->trajectory ? o->trajectory : "none");
    gsfix_json_text(ctx, t, "condition", o->condition ? o->condition : "none");
    gsfix_json_text(ctx, t, "seed", gsfix_pathf("%llu", (unsigned long long)o->seed).s);
    gsfix_json_number(ctx, t, "iterations", job->setup.fix.train.iterations);
    gsfix_json_text(ctx, t, "quality", gsfix_find_quality(o->quality)->name);
    gsfix_json_text(ctx, t, "set", o->settings ? o->settings : "");
    gsfix_json_number(ctx, t, "test_every", o->test_every ? o->test_every : 8);
    gsfix_json_number(ctx, t, "factor", o->factor ? o->factor : 1);
    gsfix_json_number(ctx, t, "max_size", o->max_size);
    gsfix_json_text(ctx, t, "photo_masks", o->photo_masks ? o->photo_masks : "on");
    gsfix_json_number(ctx, t, "frames", o->frames ? o->frames : 49);
    gsfix_json_text(ctx, t, "metrics", job->plan->which);
    if (!o->restorer || strncmp(o->restorer, "dit:", 4) != 0) return;
    gsfix_json_text(ctx, t, "caption", o->caption ? o->caption : "");
    gsfix_json_number(ctx, t, "steps", o->steps);
    gsfix_json_text(ctx, t, "solver", o->solver ? o->solver : "default");
    gsfix_json_number(ctx, t, "guidance", o->guidance);
    gsfix_json_number(ctx, t, "guidance_until", o->guidance_until);
    gsfix_json_number(ctx, t, "strength", o->strength);
    gsfix_json_number(ctx, t, "block_cache", o->block_cache);
    gsfix_json_bool(ctx, t, "int8", o->int8);
    gsfix_json_bool(ctx, t, "bf16", o->bf16);
}

static int eval_begin(gsfix_app* app, const eval_plan* plan, size_t i, eval_job* job) { // 0 or an exit code
    memset(job, 0, sizeof *job);
    job->app = app;
    job->plan = plan;
    job->run = &plan->runs[i];
    job->name = plan->names[i];
    job->before = app->o;
    eval_set_options(job);
    const char* caption = app->o.caption;
    if (job->run->kind == EVAL_ARTIFACTS) app->o.caption = NULL; // what the sequences say is no option of a restorer
    const int code = gsfix_resolve_setup(app, &job->setup);
    app->o.caption = caption;
    if (!code) eval_write_settings(job);
    return code;
}

static void eval_end(eval_job* job) {
    gsf_destroy_buffer(&job->app->ctx, &job->settings);
    job->app->o = job->before;
}

// ---- results -----------------------------------------------------------------------

static gsf_result eval_write_text(eval_job* job, const char* name, gsf_buffer* text) { // destroys text
    gsf_context* ctx = &job->app->ctx;
    gsf_append_bytes(ctx, text, "\n", 1);
    gsf_result result = text->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    if (result == GSF_OK) result = gsf_write_file(ctx, gsfix_pathf("%s/%s", job->app->o.out, name).s, text->data, text->size);
    gsf_destroy_buffer(ctx, text);
    return result;
}

static void eval_begin_result(eval_job* job, gsf_buffer* t) {
    gsf_context* ctx = &job->app->ctx;
    gsfix_json_begin(ctx, t, NULL, '{');
    gsfix_json_text(ctx, t, "format", "gsfixer evaluation 1");
    gsfix_json_begin(ctx, t, "settings", '{');
    t->size--; // drop the brace; the object itself is appended
    gsf_append_bytes(ctx, t, job->settings.data, job->settings.size);
    gsfix_json_end(ctx, t, '}');
    if (job->settings.failed) t->failed = 1;
    gsfix_json_text(ctx, t, "isa", gsf_describe_cpu_level(ctx->cpu_level));
}

static void eval_put_scores(gsf_context* ctx, gsf_buffer* t, const double scores[EVAL_SCORES]) {
    gsfix_json_begin(ctx, t, "scores", '{');
    for (int s = 0; s < EVAL_SCORES; s++)
        if (!isnan(scores[s])) gsfix_json_number(ctx, t, eval_scores[s].metric, scores[s]);
    gsfix_json_end(ctx, t, '}');
}

static gsf_result eval_save_result(eval_job* job, gsf_buffer* t, const double scores[EVAL_SCORES]) {
    gsf_context* ctx = &job->app->ctx;
    eval_put_scores(ctx, t, scores);
    eval_put_scores(ctx, &job->app->json, scores);
    gsfix_json_end(ctx, t, '}');
    return eval_write_text(job, "result.json", t);
}

// Reads OUT/TASK/result.json if it was made with the task's settings. 0: there is no such result.
static int eval_read_result(gsfix_app* app, const eval_job* job, const char* folder, double scores[EVAL_SCORES]) {
    gsf_context* ctx = &app->ctx;
    const gsfix_path path = gsfix_pathf("%s/result.json", folder);
    gsf_json json = {0};
    gsf_buffer settings = {0};
    void* data = NULL;
    size_t size = 0;
    for (int s = 0; s < EVAL_SCORES; s++) scores[s] = NAN;
    if (!gsfix_exists(path.s) || gsfix_exists(gsfix_pathf("%s/checkpoint", folder).s)) return 0;
    gsf_append_bytes(ctx, &settings, job->settings.data, job->settings.size);
    gsf_append_bytes(ctx, &settings, "}", 1);
    int ok = !settings.failed && gsf_read_file(ctx, path.s, &data, &size) == GSF_OK &&
             gsf_parse_json(ctx, path.s, (const char*)data, size, &json) == GSF_OK;
    const gsf_json_value* was = ok ? gsf_find_json_member(&json, json.values, "settings") : NULL;
    const gsf_json_value* list = ok ? gsf_find_json_member(&json, json.values, "scores") : NULL;
    ok = ok && list && gsfix_compare_settings(ctx, path.s, &settings, &json, was) == GSF_OK;
    for (int s = 0; s < EVAL_SCORES && ok; s++) {
        const gsf_json_value* v = gsf_find_json_member(&json, list, eval_scores[s].metric);
        if (v && v->type == GSF_JSON_NUMBER) scores[s] = v->number;
    }
    gsf_destroy_json(ctx, &json);
    gsf_destroy_buffer(ctx, &settings);
    gsf_free(ctx, data);
    ctx->error[0] = 0;
    return ok;
}

// What an earlier run has left is continued or, with --restart, replaced; results of other settings stay.
static gsf_result eval_meet_earlier(eval_job* job) {
    const gsfix_options* o = &job->app->o;
    if (o->restart || !gsfix_exists(gsfix_pathf("%s/result.json", o->out).s) ||
        (o->resume && gsfix_exists(gsfix_pathf("%s/checkpoint", o->out).s)))
        return GSF_OK;
    return gsf_fail(&job->app->ctx, GSF_ERROR_INVALID_ARGUMENT,
                    o->resume ? "%s/result.json: made with other settings or another version (--restart begins anew)"
                              : "%s holds the results of a run: --resume goes on, --restart begins anew", o->out);
}

// ---- reconstruction ------------------------------------------------------------------

static gsf_result eval_claim_reconstruction(gsfix_app* app, void* user) {
    const eval_job* job = (const eval_job*)user;
    const gsf_result result = gsfix_claim(app, "result.json");
    return result == GSF_OK && job->run->seed == 0 ? gsfix_claim(app, "pictures/*.jpg") : result;
}

// LPIPS of the held-out views, from the pictures that have just been written.
static gsf_result eval_measure_views(eval_job* job, const gsfix_result* r, double* lpips) {
    gsf_context* ctx = &job->app->ctx;
    gsfix_meter* meter = NULL;
    *lpips = NAN;
    if (!strstr(job->plan->which, eval_scores[2].metric)) return GSF_OK;
    gsf_result result = gsfix_make_meter(job->app, eval_scores[2].metric, NULL, 0, &meter);
    for (size_t i = 0; i < r->split->test_count && result == GSF_OK; i++) {
        const uint32_t view = r->split->test[i];
        gsf_image picture = {0};
        result = gsf_load_image(ctx, gsfix_pathf("%s/test/%s.png", r->out, gsfix_view_stem(r->scene, view).s).s, 3, &picture);
        if (result == GSF_OK)
            result = gsfix_meter_frame(job->app, meter, &picture, &r->scene->views[view].image, NULL);
        gsf_destroy_image(ctx, &picture);
    }
    if (result == GSF_OK) *lpips = gsfix_read_meter(meter, eval_scores[2].metric);
    gsfix_destroy_meter(job->app, meter);
    return result;
}

static gsf_result eval_save_pictures(eval_job* job, const gsfix_result* r) { // the trained splats along the capture
    gsf_context* ctx = &job->app->ctx;
    uint32_t views[EVAL_PICTURES];
    gsfix_path paths[EVAL_PICTURES];
    gsf_image images[EVAL_PICTURES];
    gsf_rasterizer* rasterizer = NULL;
    const size_t photos = r->scene->view_count;
    size_t count = 0, made = 0;
    gsf_splat_split_views(photos, 0, photos < EVAL_PICTURES ? photos : EVAL_PICTURES, views, &count, NULL, NULL);
    gsf_result result = gsf_splat_make_rasterizer(ctx, &rasterizer);
    for (; made < count && result == GSF_OK; made++) {
        const gsf_camera* camera = &r->scene->views[views[made]].camera;
        gsf_render_output out = {0};
        paths[made] = gsfix_pathf("%s/pictures/%02zu.jpg", r->out, made);
        result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &images[made]);
        out.color = images[made];
        if (result == GSF_OK) result = gsf_splat_render(ctx, rasterizer, r->splats, camera, &r->render, &out);
        gsfix_clamp(&images[made]);
    }
    if (result == GSF_OK) result = gsfix_save_images(ctx, paths, images, count);
    while (made) gsf_destroy_image(ctx, &images[--made]);
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    return result;
}

static gsf_result eval_finish_reconstruction(gsfix_app* app, const gsfix_result* r, void* user) {
    eval_job* job = (eval_job*)user;
    gsf_context* ctx = &app->ctx;
    gsf_buffer t = {0};
    double scores[EVAL_SCORES] = {r->mean.psnr, r->mean.ssim, NAN, NAN, NAN, NAN, NAN, NAN};
    if (!r->split->test_count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: no held-out view to measure", r->scene->folder);
    gsf_result result = eval_measure_views(job, r, &scores[2]);
    if (result == GSF_OK && job->run->seed == 0) result = eval_save_pictures(job, r);
    if (result != GSF_OK) return result;
    eval_begin_result(job, &t);
    gsfix_json_number(ctx, &t, "splats", (double)r->splats->count);
    gsfix_json_begin(ctx, &t, "per_view", '[');
    for (size_t i = 0; i < r->split->test_count; i++) {
        gsfix_json_begin(ctx, &t, NULL, '{');
        gsfix_json_text(ctx, &t, "name", r->scene->views[r->split->test[i]].name);
        gsfix_json_number(ctx, &t, "psnr", r->views[i].psnr);
        gsfix_json_number(ctx, &t, "ssim", r->views[i].ssim);
        gsfix_json_end(ctx, &t, '}');
    }
    gsfix_json_end(ctx, &t, ']');
    return eval_save_result(job, &t, scores);
}

static gsf_result eval_reconstruct(eval_job* job) {
    const gsfix_fix_task task = {eval_claim_reconstruction, eval_finish_reconstruction, job};
    gsf_result result = eval_meet_earlier(job);
    if (result == GSF_OK) result = gsfix_fix_scene(job->app, &job->setup, &task);
    return result == GSF_OK ? gsfix_remove_output(job->app, "checkpoint") : result;
}

// ---- restoration -----------------------------------------------------------------------

gsfix_path eval_artifacts_folder(const eval_plan* plan, const eval_run* run) {
    return gsfix_pathf("%s/%s.artifacts.k%d.s%d", plan->given.out, plan->scenes[run->scene], run->views, run->seed);
}

gsf_result eval_load_sequences(gsf_context* ctx, gsfix_path folder, eval_sequences* out) {
    gsfix_scene_manifest manifest;
    const gsfix_path path = gsfix_pathf("%s/manifest.json", folder.s);
    uint64_t size = 0;
    memset(out, 0, sizeof *out);
    out->folder = folder;
    gsf_result result = gsfix_load_scene_manifest(ctx, path.s, &manifest);
    if (result != GSF_OK) return result;
    if (!gsfix_digest_file(path.s, &size, &out->digest)) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be read", path.s);
    out->items = (gsfix_sequence*)gsf_alloc_zeroed(ctx, manifest.sequence_count, sizeof *out->items);
    if (!out->items) result = GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < manifest.sequence_count && result == GSF_OK; i++) {
        result = gsfix_load_sequence(ctx, gsfix_pathf("%s/%s", folder.s, manifest.sequences[i].file), &out->items[i]);
        out->count += result == GSF_OK;
    }
    gsfix_free_scene_manifest(ctx, &manifest);
    return result;
}

void eval_free_sequences(gsf_context* ctx, eval_sequences* s) {
    for (size_t i = 0; i < s->count; i++) gsfix_free_sequence(ctx, &s->items[i]);
    gsf_free(ctx, s->items);
}

gsfix_path eval_frame_name(size_t sequence, const gsfix_sequence_frame* frame) {
    return gsfix_pathf("sequence_%02zu/%s.png", sequence, frame->name);
}

static gsf_result eval_load_frame(gsf_context* ctx, const eval_sequences* s, const gsfix_sequence_frame* frame, int file,
                                  int32_t channels, gsf_image* out) {
    const gsfix_path path = gsfix_pathf("%s/%s", s->folder.s, frame->files[file]);
    return file == GSFIX_DEPTH ? gsfix_load_npy(ctx, path.s, out) : gsfix_load_float(ctx, path.s, channels, out);
}

static gsf_result eval_load_clip(eval_job* job, const eval_sequences* s, size_t i, gsfix_clip* c) {
    gsf_context* ctx = &job->app->ctx;
    const gsfix_sequence* q = &s->items[i];
    gsf_result result = gsfix_make_clip(ctx, q->frame_count, c);
    if (result == GSF_OK)
        result = gsf_load_cameras(ctx, gsfix_pathf("%s/%s", s->folder.s, q->cameras).s, &c->cameras, &c->camera_count);
    if (result == GSF_OK && c->camera_count != q->frame_count)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s/%s: %zu cameras for %zu frames", s->folder.s, q->cameras, c->camera_count,
                          q->frame_count);
    for (size_t f = 0; f < q->frame_count && result == GSF_OK; f++) {
        result = eval_load_frame(ctx, s, &q->frames[f], GSFIX_ARTIFACT, 3, &c->color[f]);
        if (result == GSF_OK) result = eval_load_frame(ctx, s, &q->frames[f], GSFIX_DEPTH, 1, &c->depth[f]);
        if (result == GSF_OK) result = eval_load_frame(ctx, s, &q->frames[f], GSFIX_ALPHA, 1, &c->alpha[f]);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, q->width, q->height, 3, &c->out_color[f]);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, q->width, q->height, 1, &c->out_confidence[f]);
    }
    if (result != GSF_OK) return result;
    c->reference_index[0] = (int32_t)i;
    c->reference_index[q->frame_count - 1] = (int32_t)i + 1;
    return GSF_OK;
}

// The photos that the artifacts' splats were trained on: the ends of the sequences.
static gsf_result eval_load_references(eval_job* job, const eval_sequences* s, gsfix_clip* c) {
    gsf_context* ctx = &job->app->ctx;
    gsf_result result = GSF_OK;
    c->references = (gsf_reference*)gsf_alloc_zeroed(ctx, s->count + 1, sizeof *c->references);
    if (!c->references) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i <= s->count && result == GSF_OK; i++) {
        const gsfix_sequence* q = &s->items[i ? i - 1 : 0];
        const size_t at = i ? q->frame_count - 1 : 0;
        gsf_reference* r = &c->references[c->refs++];
        gsf_camera* cameras = NULL;
        size_t count = 0;
        result = eval_load_frame(ctx, s, &q->frames[at], GSFIX_CLEAN, 3, &r->color);
        if (result == GSF_OK) result = eval_load_frame(ctx, s, &q->frames[at], GSFIX_ARTIFACT, 3, &r->render);
        if (result == GSF_OK) result = eval_load_frame(ctx, s, &q->frames[at], GSFIX_DEPTH, 1, &r->depth);
        if (result == GSF_OK) result = gsf_load_cameras(ctx, gsfix_pathf("%s/%s", s->folder.s, q->cameras).s, &cameras, &count);
        if (result == GSF_OK && at < count) r->camera = cameras[at];
        gsf_free(ctx, cameras);
    }
    return result;
}

static int eval_is_restored(const eval_job* job, const eval_sequences* s, size_t i) {
    for (size_t f = 0; f < s->items[i].frame_count; f++)
        if (!gsfix_has_output(job->app, eval_frame_name(i, &s->items[i].frames[f]).s)) return 0;
    return 1;
}

static gsf_result eval_restore_sequence(eval_job* job, const eval_sequences* s, size_t i) {
    gsfix_app* app = job->app;
    gsf_context* ctx = &app->ctx;
    const gsfix_sequence* q = &s->items[i];
    gsfix_clip c = {0};
    gsf_restorer restorer = {0};
    int present = 0;
    gsfix_path* paths = (gsfix_path*)gsf_alloc(ctx, q->frame_count, sizeof *paths);
    gsf_result result = paths ? eval_load_clip(job, s, i, &c) : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) result = eval_load_references(job, s, &c);
    if (result == GSF_OK) result = gsfix_make_restorer(app, &restorer, &present);
    if (result == GSF_OK) result = gsfix_restore_clip(app, &c, &restorer);
    for (size_t f = 0; f < q->frame_count && result == GSF_OK; f++) {
        gsfix_clamp(&c.out_color[f]);
        paths[f] = gsfix_pathf("%s/%s", app->o.out, eval_frame_name(i, &q->frames[f]).s);
    }
    if (result == GSF_OK) result = gsfix_save_images(ctx, paths, c.out_color, q->frame_count);
    if (result == GSF_OK) result = gsfix_drop_dit_checkpoint(app);
    gsf_destroy_restorer(&app->ctx, &restorer);
    gsfix_free_clip(app, &c);
    gsf_free(ctx, paths);
    return result;
}

// Measures the frames as written. Metrics of pairs leave out the references, which are known; clips include both ends.
static gsf_result eval_measure_sequence(eval_job* job, const eval_sequences* s, size_t i, double scores[EVAL_SCORES],
                                        size_t* frames) {
    gsf_context* ctx = &job->app->ctx;
    const gsfix_sequence* q = &s->items[i];
    const int artifacts = job->run->arm == job->plan->artifacts;
    gsfix_meter* meter = NULL;
    gsf_image first = {0};
    gsf_result result = gsfix_make_meter(job->app, job->plan->which, job->plan->given.caption, q->frame_count, &meter);
    if (result == GSF_OK)
        result = gsf_load_image(ctx, gsfix_pathf("%s/%s", s->folder.s, q->frames[0].files[GSFIX_CLEAN]).s, 3, &first);
    *frames = 0;
    for (size_t f = 0; f < q->frame_count && result == GSF_OK; f++) {
        const gsfix_sequence_frame* frame = &q->frames[f];
        gsf_image picture = {0}, photo = {0};
        const gsfix_path path = artifacts ? gsfix_pathf("%s/%s", s->folder.s, frame->files[GSFIX_ARTIFACT])
                                          : gsfix_pathf("%s/%s", job->app->o.out, eval_frame_name(i, frame).s);
        result = gsf_load_image(ctx, path.s, 3, &picture);
        if (result == GSF_OK)
            result = gsf_load_image(ctx, gsfix_pathf("%s/%s", s->folder.s, frame->files[GSFIX_CLEAN]).s, 3, &photo);
        if (result == GSF_OK)
            result = gsfix_meter_frame(job->app, meter, &picture, frame->reference ? NULL : &photo, &first);
        *frames += !frame->reference;
        gsf_destroy_image(ctx, &picture);
        gsf_destroy_image(ctx, &photo);
    }
    for (int m = 0; m < EVAL_SCORES && result == GSF_OK; m++) scores[m] = gsfix_read_meter(meter, eval_scores[m].metric);
    gsf_destroy_image(ctx, &first);
    gsfix_destroy_meter(job->app, meter);
    return result;
}

// A checkpoint of settings: what the sequences in the folder were restored with.
static gsf_result eval_meet_restoration(eval_job* job, const eval_sequences* s) {
    gsfix_app* app = job->app;
    gsf_context* ctx = &app->ctx;
    const gsfix_path path = gsfix_pathf("%s/checkpoint", app->o.out);
    gsf_buffer now = {0}, whole = {0};
    gsf_json json = {0};
    void* data = NULL;
    size_t size = 0;
    gsf_result result = gsfix_claim(app, "checkpoint");
    if (result == GSF_OK) result = gsfix_claim(app, "dit.checkpoint");
    if (result == GSF_OK) result = gsfix_claim(app, "dit.checkpoint.*");
    if (result == GSF_OK) result = gsfix_claim(app, "result.json");
    if (result == GSF_OK && job->run->arm != job->plan->artifacts) result = gsfix_claim(app, "sequence_*/frame_*.png");
    if (result == GSF_OK) result = gsfix_open_out(app);
    gsfix_json_text(ctx, &job->settings, "artifacts", gsfix_pathf("%016llx", (unsigned long long)s->digest).s);
    gsf_append_bytes(ctx, &now, job->settings.data, job->settings.size);
    gsfix_json_end(ctx, &now, '}');
    if (result == GSF_OK && gsfix_has_output(app, "checkpoint") && !app->o.restart) {
        if (!app->o.resume)
            result = gsf_fail(ctx, GSF_ERROR_IO, "%s holds a run that was interrupted: --resume goes on, --restart begins anew",
                              app->o.out);
        if (result == GSF_OK) result = gsf_read_file(ctx, path.s, &data, &size);
        if (result == GSF_OK) result = gsf_parse_json(ctx, path.s, (const char*)data, size, &json);
        if (result == GSF_OK) result = gsfix_compare_settings(ctx, path.s, &now, &json, json.values);
    } else if (result == GSF_OK) {
        gsf_append_bytes(ctx, &whole, now.data, now.size);
        result = gsfix_remove_output(app, "result.json");
        if (result == GSF_OK) result = gsfix_remove_stale(app);
        if (result == GSF_OK) result = now.failed ? GSF_ERROR_OUT_OF_MEMORY : eval_write_text(job, "checkpoint", &whole);
    }
    gsf_destroy_json(ctx, &json);
    gsf_free(ctx, data);
    gsf_destroy_buffer(ctx, &now);
    gsf_destroy_buffer(ctx, &whole);
    return result;
}

static gsf_result eval_restore_all(eval_job* job, const eval_sequences* s, gsf_buffer* t, double scores[EVAL_SCORES]) {
    gsfix_app* app = job->app;
    gsf_context* ctx = &app->ctx;
    double weights[EVAL_SCORES] = {0}, sums[EVAL_SCORES] = {0};
    gsf_result result = GSF_OK;
    gsfix_json_begin(ctx, t, "sequences", '[');
    for (size_t i = 0; i < s->count && result == GSF_OK; i++) {
        double values[EVAL_SCORES];
        size_t frames = 0;
        if (gsf_is_cancelled(ctx)) result = gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled");
        if (result == GSF_OK && job->run->arm != job->plan->artifacts && !eval_is_restored(job, s, i))
            result = eval_restore_sequence(job, s, i);
        if (result == GSF_OK) result = eval_measure_sequence(job, s, i, values, &frames);
        gsfix_progress(app, (double)(i + 1), (double)s->count, "%s: sequence %zu of %zu", job->name, i + 1, s->count);
        if (result != GSF_OK) break;
        for (int m = 0; m < EVAL_SCORES; m++) {
            const double weight = eval_scores[m].of_clip ? 1.0 : (double)frames;
            if (isnan(values[m]) || weight == 0.0) continue;
            sums[m] += weight * values[m];
            weights[m] += weight;
        }
        gsfix_json_begin(ctx, t, NULL, '{');
        gsfix_json_number(ctx, t, "frames", (double)frames);
        eval_put_scores(ctx, t, values);
        gsfix_json_end(ctx, t, '}');
    }
    gsfix_json_end(ctx, t, ']');
    for (int m = 0; m < EVAL_SCORES; m++) scores[m] = weights[m] > 0.0 ? sums[m] / weights[m] : NAN;
    if (result != GSF_ERROR_CANCELLED) return result;
    gsf_clear_cancel(ctx);
    return gsf_fail(ctx, GSF_ERROR_CANCELLED, "stopped in %s; --resume goes on", job->name);
}

static gsf_result eval_restore(eval_job* job) {
    gsf_context* ctx = &job->app->ctx;
    eval_sequences s = {{""}, NULL, 0, 0};
    gsf_buffer t = {0};
    double scores[EVAL_SCORES];
    gsf_result result = eval_meet_earlier(job);
    if (result == GSF_OK) result = eval_load_sequences(ctx, eval_artifacts_folder(job->plan, job->run), &s);
    if (result == GSF_OK) result = eval_meet_restoration(job, &s);
    if (result == GSF_OK) {
        eval_begin_result(job, &t);
        result = eval_restore_all(job, &s, &t, scores);
    }
    if (result == GSF_OK) result = eval_save_result(job, &t, scores);
    if (result == GSF_OK) result = gsfix_remove_output(job->app, "checkpoint");
    gsf_destroy_buffer(ctx, &t);
    eval_free_sequences(ctx, &s);
    return result;
}

// ---- tasks -----------------------------------------------------------------------------

static gsf_result eval_make_artifacts(eval_job* job) {
    gsfix_dataset_plan* plan = NULL;
    const int code = gsfix_make_dataset_plan(job->app, &plan);
    gsf_result result = code ? gsf_fail(&job->app->ctx, GSF_ERROR_INVALID_ARGUMENT, "the settings are not those of a dataset")
                             : gsfix_make_dataset_scene(job->app, plan, job->plan->scenes[job->run->scene], job->input);
    gsfix_destroy_dataset_plan(job->app, plan);
    return result;
}

static gsf_result eval_run_task(gsfix_app* app, void* user, size_t task) {
    const eval_plan* plan = (const eval_plan*)user;
    const double begin = gsfix_now(), started = app->started;
    eval_job job;
    gsf_result result = GSF_OK;
    app->started = begin;
    if (eval_begin(app, plan, task, &job)) result = gsf_fail(&app->ctx, GSF_ERROR_INVALID_ARGUMENT, "bad settings");
    else if (job.run->kind == EVAL_RECONSTRUCTION) result = eval_reconstruct(&job);
    else if (job.run->kind == EVAL_ARTIFACTS) result = eval_make_artifacts(&job);
    else result = eval_restore(&job);
    eval_end(&job);
    app->started = started;
    if (result == GSF_OK) gsfix_json_number(&app->ctx, &app->json, "seconds", gsfix_now() - begin);
    if (result == GSF_OK && plan->runs[task].kind != EVAL_ARTIFACTS)
        gsfix_print(app, "%-44s %.1f s", plan->names[task], gsfix_now() - begin);
    return result;
}

static int eval_is_done(gsfix_app* app, void* user, size_t task) {
    const eval_plan* plan = (const eval_plan*)user;
    gsfix_dataset_plan* artifacts = NULL;
    double scores[EVAL_SCORES];
    eval_job job;
    int done = eval_begin(app, plan, task, &job) == 0;
    if (done && job.run->kind == EVAL_ARTIFACTS)
        done = gsfix_make_dataset_plan(app, &artifacts) == 0 && gsfix_has_dataset_scene(app, artifacts);
    else if (done) done = eval_read_result(app, &job, app->o.out, scores);
    gsfix_destroy_dataset_plan(app, artifacts);
    eval_end(&job);
    return done;
}

static gsf_result eval_claim(gsfix_app* app, void* user) {
    static const char* const names[] = {"tables.md", "tables.tex", "tables.csv", "runs.csv", "gallery.html"};
    gsf_result result = GSF_OK;
    (void)user;
    for (size_t i = 0; i < sizeof names / sizeof *names && result == GSF_OK; i++) result = gsfix_claim(app, "%s", names[i]);
    return result;
}

// One line per run, with all its settings and figures.
static gsf_result eval_write_runs(gsfix_app* app, const eval_plan* plan) {
    gsf_context* ctx = &app->ctx;
    gsf_buffer t = {0};
    gsf_append_text(ctx, &t, "run,scene,views,start,method,trajectory,condition,seed");
    for (int s = 0; s < EVAL_SCORES; s++) gsf_append_text(ctx, &t, ",%s", eval_scores[s].metric);
    gsf_append_text(ctx, &t, "\n");
    for (size_t i = 0; i < plan->run_count; i++) {
        const eval_run* r = &plan->runs[i];
        if (r->kind == EVAL_ARTIFACTS || !r->done) continue;
        gsf_append_text(ctx, &t, "%s,%s,%d,%s,%s,%s,%s,%llu", plan->names[i], plan->scenes[r->scene], r->views,
                        r->init >= 0 ? plan->inits.items[r->init] : "tracks", plan->arms[r->arm].name,
                        r->trajectory >= 0 ? plan->trajectories.items[r->trajectory] : "",
                        r->condition >= 0 ? plan->conditions.items[r->condition] : "",
                        (unsigned long long)(plan->given.seed + (uint64_t)r->seed));
        for (int s = 0; s < EVAL_SCORES; s++)
            gsf_append_text(ctx, &t, isnan(r->scores[s]) ? "," : ",%.6f", r->scores[s]);
        gsf_append_text(ctx, &t, "\n");
    }
    const gsf_result result = t.failed ? GSF_ERROR_OUT_OF_MEMORY
                                       : gsf_write_file(ctx, gsfix_pathf("%s/runs.csv", app->o.out).s, t.data, t.size);
    gsf_destroy_buffer(ctx, &t);
    return result;
}

static gsf_result eval_merge(gsfix_app* app, void* user) {
    eval_plan* plan = (eval_plan*)user;
    gsf_context* ctx = &app->ctx;
    plan->missing = plan->measured = 0;
    for (size_t i = 0; i < plan->run_count; i++) {
        eval_job job;
        if (plan->runs[i].kind == EVAL_ARTIFACTS) continue;
        if (eval_begin(app, plan, i, &job) == 0)
            plan->runs[i].done = eval_read_result(app, &job, gsfix_pathf("%s/%s", app->o.out, plan->names[i]).s,
                                                  plan->runs[i].scores);
        eval_end(&job);
        plan->measured += plan->runs[i].done;
        plan->missing += !plan->runs[i].done;
    }
    gsf_result result = eval_write_tables(app, plan);
    if (result == GSF_OK) result = eval_write_runs(app, plan);
    if (result == GSF_OK) result = eval_write_gallery(app, plan);
    if (result != GSF_OK) return result;
    gsfix_json_number(ctx, &app->json, "runs", (double)plan->measured);
    gsfix_json_number(ctx, &app->json, "missing", (double)plan->missing);
    gsfix_json_number(ctx, &app->json, "seconds", gsfix_now() - app->started);
    gsfix_print(app, "wrote      %s/tables.md  tables.tex  tables.csv  runs.csv  gallery.html: %zu runs, %.1f s", app->o.out,
                plan->measured, gsfix_now() - app->started);
    return GSF_OK;
}

// Tries all arms' settings and opens the metrics' networks, so that mistakes are found before any work.
static int eval_check(gsfix_app* app, const eval_plan* plan) {
    gsfix_meter* meter = NULL;
    int code = 0;
    for (size_t i = 0; i < plan->run_count && !code; i++) {
        eval_job job;
        if (plan->runs[i].scene) break; // the other scenes' runs have the same settings
        code = eval_begin(app, plan, i, &job);
        eval_end(&job);
    }
    if (!code && !app->o.list_tasks && gsfix_make_meter(app, plan->which, plan->given.caption, 3, &meter) != GSF_OK)
        code = gsfix_failed(app);
    gsfix_destroy_meter(app, meter);
    return code;
}

int gsfix_run_evaluate(gsfix_app* app) {
    static const eval_plan zero;
    gsf_context* ctx = &app->ctx;
    eval_plan plan = zero;
    plan.given = app->o;
    plan.scene_count = app->o.input_count;
    int code = eval_parse(app, &plan);
    if (!code && (gsfix_name_scenes(app, &plan.scenes) != GSF_OK || eval_list_runs(app, &plan) != GSF_OK))
        code = gsfix_failed(app);
    if (!code) code = eval_check(app, &plan);
    if (!code) {
        const gsfix_tasks tasks = {plan.names, plan.run_count, &plan, eval_claim, eval_is_done, eval_run_task, eval_merge,
                                   plan.needs, 1};
        code = gsfix_run_tasks(app, &tasks);
    }
    gsfix_names scenes = {plan.scenes, plan.scenes ? (size_t)plan.scene_count : 0}, names = {plan.names, plan.run_count};
    gsfix_free_names(ctx, &scenes);
    gsfix_free_names(ctx, &names);
    gsf_free(ctx, plan.runs);
    gsf_free(ctx, plan.needs);
    gsf_free(ctx, plan.texts);
    return code;
}
