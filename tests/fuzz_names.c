// fuzz_names.c - gsfix's list of training views (--views FILE). Build line: fuzz.h, with examples/gsfix*.c.
#include "../examples/gsfix.h"

#include "fuzz.h"

enum { VIEWS = 12 };

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    static char* const names[VIEWS] = {"a", "a.png", "b c.jpg", "c/d.png", "d\xc3\xa9.png", "e.png", "f.png", "g.png", "h.png",
                                       "i", "j.png", "k.png"};
    static gsfix_app app;
    gsf_scene_view views[VIEWS];
    gsf_scene scene;
    gsfix_split split;
    uint8_t times[VIEWS] = {0};
    fuzz_file files[] = {{"fuzz.txt", data, size}, {NULL, NULL, 0}};
    memset(&app, 0, sizeof app);
    memset(&scene, 0, sizeof scene);
    memset(views, 0, sizeof views);
    app.ctx = fuzz_context(size);
    fuzz_hook_files(&app.ctx, files);
    app.o.views = "fuzz.txt";
    for (int i = 0; i < VIEWS; i++) views[i].name = names[i];
    scene.views = views;
    scene.view_count = VIEWS;
    const gsf_result result = gsfix_split_scene(&app, &scene, &split);
    if (result == GSF_OK) {
        for (size_t i = 0; i < split.train_count; i++) FUZZ_CHECK(split.train[i] < VIEWS && !times[split.train[i]]++);
        for (size_t i = 0; i < split.test_count; i++) FUZZ_CHECK(split.test[i] < VIEWS && !times[split.test[i]]++);
        FUZZ_CHECK(split.train_count > 0);
    } else {
        FUZZ_CHECK(result == GSF_ERROR_INVALID_ARGUMENT);
        fuzz_check_error(&app.ctx, "");
    }
    gsfix_free_split(&app, &split);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
