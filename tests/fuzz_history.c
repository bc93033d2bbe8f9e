// fuzz_history.c - gsfix fix's record of a run in its checkpoint. Build line: fuzz.h, with the other examples/gsfix*.c.
// Accepted records are in range and survive being written and read again.
#include "../examples/gsfix_fix.c"

#include "fuzz.h"

enum { VIEWS = 2, ITERATIONS = 1000 };

static void begin(fix_run* run, gsfix_app* app) {
    memset(run, 0, sizeof *run);
    run->app = app;
    run->ctx = &app->ctx;
    run->iterations = ITERATIONS;
    run->history.view_count = VIEWS;
    run->history.without = (gsfix_score*)gsf_alloc_zeroed(run->ctx, VIEWS, sizeof(gsfix_score));
    FUZZ_CHECK(run->history.without);
    gsf_append_text(run->ctx, &run->switches, "{}");
}

static void end(fix_run* run) {
    gsfix_history* h = &run->history;
    void* const lists[] = {h->without, h->without_curve, h->curve, h->rounds, h->path, h->samples};
    for (size_t i = 0; i < sizeof lists / sizeof *lists; i++) gsf_free(run->ctx, lists[i]);
    gsf_destroy_buffer(run->ctx, &run->switches);
}

static gsf_result read_back(fix_run* run, const char* text, size_t size) {
    gsf_json json;
    gsf_result result = gsf_parse_json(run->ctx, "fuzz", text, size, &json);
    if (result != GSF_OK) return result;
    result = compare_switches(run, "fuzz", &json, gsf_find_json_member(&json, &json.values[0], "switches"));
    if (result == GSF_OK) result = compare_inputs(run, "fuzz", &json,
                                                  gsf_find_json_member(&json, &json.values[0], "inputs"));
    if (result == GSF_OK) result = read_history(run, "fuzz", &json);
    gsf_destroy_json(run->ctx, &json);
    return result;
}

static void check_same(const gsfix_history* a, const gsfix_history* b) {
    FUZZ_CHECK(a->curve_count == b->curve_count && a->without_count == b->without_count && a->round_count == b->round_count);
    FUZZ_CHECK(a->path_count == b->path_count && a->sample_count == b->sample_count && a->has_without == b->has_without);
    for (size_t i = 0; i < a->curve_count; i++)
        FUZZ_CHECK(a->curve[i].iteration == b->curve[i].iteration && a->curve[i].splats == b->curve[i].splats);
    for (size_t i = 0; i < a->path_count; i++) FUZZ_CHECK(memcmp(a->path + i, b->path + i, 12) == 0);
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    static gsfix_app app;
    fix_run run, again;
    memset(&app, 0, sizeof app);
    app.ctx = fuzz_context(size);
    app.o.compare = 1;
    fuzz_limit += 128 * size; // its lists, their JSON, and the parsed values
    begin(&run, &app);
    const gsf_result result = read_back(&run, size ? (const char*)data : "", size);
    if (result == GSF_OK) {
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        FUZZ_CHECK(run.iteration >= 0 && run.iteration <= ITERATIONS && run.history.resumed > 0);
        write_history(&run, &text);
        begin(&again, &app);
        FUZZ_CHECK(!text.failed && read_back(&again, text.data, text.size) == GSF_OK);
        check_same(&run.history, &again.history);
        gsf_destroy_buffer(&app.ctx, &text);
        end(&again);
    } else {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_INVALID_ARGUMENT);
        fuzz_check_error(&app.ctx, "fuzz:");
    }
    end(&run);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
