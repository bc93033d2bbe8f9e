// gsfix_tasks.c - commands whose work is a list of independent tasks, see gsfix.h
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#ifdef _WIN32
#include "gsfix_windows.h"
#define realpath(path, room) gsfix_w_realpath(path)
#endif

// ---- names -----------------------------------------------------------------------

// The last part of a path that says something: nerfstudio/ and colmap/ are what DL3DV calls the folder in each scene.
static gsfix_path scene_name(const char* path, int parents) {
    char* real = realpath(path, NULL);
    gsfix_path rest = gsfix_pathf("%s", real ? real : path), name = {""};
    free(real);
    for (int taken = -1; taken < parents;) {
        char* slash = strrchr(rest.s, '/');
        const char* part = slash ? slash + 1 : rest.s;
        const int counts = *part && strcmp(part, "nerfstudio") && strcmp(part, "colmap") && !strstr(part, ".json");
        if (counts) name = name.s[0] ? gsfix_pathf("%s_%s", part, name.s) : gsfix_pathf("%s", part);
        taken += counts;
        if (!slash) break;
        *slash = 0;
    }
    for (char* p = name.s; *p; p++)
        if ((unsigned char)*p <= 0x20 || *p == '*' || *p == 0x7f || (p == name.s && *p == '.')) *p = '_';
    return name.s[0] ? name : gsfix_pathf("scene");
}

gsf_result gsfix_name_scenes(gsfix_app* app, char*** names) {
    gsf_context* ctx = &app->ctx;
    const size_t count = (size_t)app->o.input_count;
    char** list = (char**)gsf_alloc_zeroed(ctx, count + 1, sizeof *list);
    *names = list;
    if (!list) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) {
        const gsfix_path mine = scene_name(app->o.inputs[i], 0);
        int parents = 0;
        for (size_t k = 0; k < count; k++)
            if (k != i && strcmp(scene_name(app->o.inputs[k], 0).s, mine.s) == 0) parents = 1;
        const gsfix_path name = scene_name(app->o.inputs[i], parents);
        if (strlen(name.s) > 200)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: too long a name", app->o.inputs[i]);
        list[i] = gsfix_copy_text(ctx, name.s, strlen(name.s));
        if (!list[i]) return GSF_ERROR_OUT_OF_MEMORY;
        for (size_t k = 0; k < i; k++)
            if (strcmp(list[k], list[i]) == 0)
                return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s and %s: both would be called %s", app->o.inputs[k],
                                app->o.inputs[i], list[i]);
    }
    return GSF_OK;
}

// ---- tasks -----------------------------------------------------------------------

// Files and hooks for work in another folder than before.
static gsf_result enter(gsfix_app* app, const char* out) {
    gsfix_end_files(app);
    app->o.out = out;
    return gsfix_begin_files(app);
}

static gsf_result open_merged(gsfix_app* app, const gsfix_tasks* t, const char* out) {
    gsf_result result = enter(app, out);
    if (result == GSF_OK) result = t->claim_fn(app, t->user);
    return result == GSF_OK ? gsfix_open_out(app) : result;
}

static gsf_result run_task(gsfix_app* app, const gsfix_tasks* t, const char* out, size_t i) {
    gsf_context* ctx = &app->ctx;
    const gsfix_path folder = gsfix_pathf("%s/%s", out, t->names[i]);
    gsf_buffer outer = app->json;
    const gsf_buffer empty = {0};
    app->json = empty;
    app->line_share = -1;
    ctx->error[0] = 0;
    gsfix_json_begin(ctx, &app->json, NULL, '{');
    gsfix_json_text(ctx, &app->json, "name", t->names[i]);
    gsf_result result = enter(app, folder.s);
    const int done = result == GSF_OK && app->o.resume && t->done_fn(app, t->user, i);
    if (result == GSF_OK && done) gsfix_json_bool(ctx, &app->json, "done_before", 1);
    if (result == GSF_OK && !done) result = enter(app, folder.s); // forgets what done_fn has read
    if (result == GSF_OK && !done) result = t->run_fn(app, t->user, i);
    if (result != GSF_OK) gsfix_json_text(ctx, &app->json, "error", ctx->error);
    gsfix_json_end(ctx, &app->json, '}');
    if (outer.size && outer.data[outer.size - 1] != '[') gsf_append_bytes(ctx, &outer, ",", 1);
    gsf_append_bytes(ctx, &outer, app->json.data, app->json.size);
    gsf_destroy_buffer(ctx, &app->json);
    app->json = outer;
    gsfix_end_files(app);
    app->o.out = out;
    return result;
}

void gsfix_note_task(gsfix_app* app, gsfix_tally* tally, size_t task, gsf_result result, const char* text) {
    tally->done[task] = result == GSF_OK;
    if (result == GSF_OK) return;
    if (!text || !text[0]) text = "out of memory";
    if (!tally->failed++) tally->why = result, snprintf(tally->first, sizeof tally->first, "%s", text);
    if (tally->tasks->count > 1 && result != GSF_ERROR_CANCELLED) gsfix_note(app, "%s: %s", tally->tasks->names[task], text);
}

// A task whose predecessor has failed; its folder is not touched.
static gsf_result skip_task(gsfix_app* app, const gsfix_tasks* t, size_t i) {
    gsf_context* ctx = &app->ctx;
    gsfix_json_begin(ctx, &app->json, NULL, '{');
    gsfix_json_text(ctx, &app->json, "name", t->names[i]);
    const gsf_result result = gsf_fail(ctx, GSF_ERROR_IO, "needs %s, which is not done", t->names[t->needs[i]]);
    gsfix_json_text(ctx, &app->json, "error", ctx->error);
    gsfix_json_end(ctx, &app->json, '}');
    return result;
}

static gsf_result run_in_order(gsfix_app* app, const char* out, gsfix_tally* tally) {
    const gsfix_tasks* t = tally->tasks;
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < t->count && result != GSF_ERROR_CANCELLED; i++) {
        const int ready = !t->needs || t->needs[i] == i || tally->done[t->needs[i]];
        if (t->count > 1) gsfix_note(app, "%s (%zu of %zu)", t->names[i], i + 1, t->count);
        result = ready ? run_task(app, t, out, i) : skip_task(app, t, i);
        gsfix_note_task(app, tally, i, result, app->ctx.error);
    }
    return result == GSF_ERROR_CANCELLED ? result : GSF_OK;
}

static gsf_result run_all(gsfix_app* app, const gsfix_tasks* t, const char* out, size_t* done) {
    gsf_context* ctx = &app->ctx;
    gsfix_tally tally = {t, NULL, 0, GSF_OK, ""};
    gsf_result result = GSF_OK;
    tally.done = (uint8_t*)gsf_alloc_zeroed(ctx, t->count + 1, 1);
    if (!tally.done) return GSF_ERROR_OUT_OF_MEMORY;
    gsfix_json_begin(ctx, &app->json, "tasks", '[');
    if (app->crew) {
        gsfix_end_files(app); // the tasks' processes open their folders themselves
        result = app->crew->run_fn(app, app->crew->user, &tally);
    } else {
        result = run_in_order(app, out, &tally);
    }
    gsfix_json_end(ctx, &app->json, ']');
    for (size_t i = 0; i < t->count; i++) *done += tally.done[i];
    gsf_free(ctx, tally.done);
    if (result != GSF_OK || !tally.failed) return result;
    if (t->count == 1) return gsf_fail(ctx, tally.why, "%s", tally.first);
    if (tally.failed == 1) return gsf_fail(ctx, tally.why, "1 of %zu not done: %s", t->count, tally.first);
    return gsf_fail(ctx, tally.why, "%zu of %zu not done, the first because of: %.350s", tally.failed, t->count, tally.first);
}

static gsf_result list_tasks(gsfix_app* app, const gsfix_tasks* t) {
    gsf_context* ctx = &app->ctx;
    gsfix_json_begin(ctx, &app->json, "tasks", '[');
    for (size_t i = 0; i < t->count; i++) {
        gsfix_json_text(ctx, &app->json, NULL, t->names[i]);
        gsfix_print(app, "%s", t->names[i]);
    }
    gsfix_json_end(ctx, &app->json, ']');
    return GSF_OK;
}

// Merges what is there after some of the tasks have failed; the failure stays what is reported, unless merging fails, too.
static gsf_result merge_partly(gsfix_app* app, const gsfix_tasks* t, const char* out, gsf_result why) {
    gsf_context* ctx = &app->ctx;
    char text[sizeof ctx->error];
    memcpy(text, ctx->error, sizeof text);
    gsf_result result = open_merged(app, t, out);
    if (result == GSF_OK) result = t->merge_fn(app, t->user);
    return result == GSF_OK ? gsf_fail(ctx, why, "%.500s", text) : result;
}

int gsfix_run_tasks(gsfix_app* app, const gsfix_tasks* t) {
    gsf_context* ctx = &app->ctx;
    const char* out = app->o.out;
    gsf_result result;
    size_t i = 0;
    if (app->o.task) {
        while (i < t->count && strcmp(t->names[i], app->o.task) != 0) i++;
        if (i == t->count) return gsfix_misused(app, "--task %s: no such task (--tasks lists them)", app->o.task);
        gsfix_json_begin(ctx, &app->json, "tasks", '[');
        result = run_task(app, t, out, i);
        gsfix_json_end(ctx, &app->json, ']');
    } else {
        result = open_merged(app, t, out); // refuses early what the merge could not do
        if (result == GSF_OK && app->o.list_tasks) result = list_tasks(app, t);
        else if (result == GSF_OK) {
            result = run_all(app, t, out, &i);
            if (result == GSF_OK) result = open_merged(app, t, out);
            if (result == GSF_OK) result = t->merge_fn(app, t->user);
            else if (i && t->merges_partly && result != GSF_ERROR_CANCELLED) result = merge_partly(app, t, out, result);
        }
    }
    app->o.out = out;
    return result == GSF_OK ? 0 : gsfix_failed(app);
}
