// fuzz_sample.c - checkpoints of an interrupted sampling run. Build line: fuzz.h, without -DGSFIXER_IMPLEMENTATION.
// Input: u8 solver, u8 number of steps after which a small job is saved, and patches to that file (fuzz_patch_chunks);
// or, with a second byte from 128 on, a whole file. A checkpoint that does not fit the job is ignored; from one that
// fits, the job continues and finishes.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "fuzz.h"

enum { VALUES = 6, STEPS = 5 };

static void begin(gsf_context* ctx, const gsf_nn_schedule* schedule, int solver, float* latents, gsf__sample_run* run) {
    gsf_nn_sampler_desc desc;
    memset(run, 0, sizeof *run);
    memset(&desc, 0, sizeof desc);
    desc.solver = (gsf_nn_solver)solver;
    desc.steps = STEPS;
    desc.value_count = VALUES;
    run->ctx = ctx;
    run->desc.checkpoint = "fuzz";
    run->latents = latents;
    run->count = VALUES;
    run->settings = 0x12345678u;
    run->clip = 0x9abcdef0u;
    for (int i = 0; i < VALUES; i++) latents[i] = 0.5f * (float)i - 1.0f;
    FUZZ_CHECK(gsf_nn_make_sampler(ctx, schedule, &desc, &run->sampler) == GSF_OK);
}

static gsf_result step(gsf__sample_run* run) {
    float velocity[VALUES];
    for (int i = 0; i < VALUES; i++) velocity[i] = 0.25f * (float)(i % 3);
    return gsf_nn_step_sampler(run->ctx, &run->sampler, velocity, run->latents, NULL);
}

static gsf_buffer make_file(gsf_context* ctx, const gsf_nn_schedule* schedule, fuzz_file* saved, const uint8_t* data,
                            size_t size) {
    gsf__sample_run run;
    float latents[VALUES];
    gsf_buffer file;
    memset(&file, 0, sizeof file);
    if (data[1] >= 128) {
        fuzz_sum_chunks(ctx, data + 2, size - 2, &file);
        return file;
    }
    begin(ctx, schedule, data[0] % 3, latents, &run);
    for (int i = 0; i < data[1] % (STEPS + 1); i++) FUZZ_CHECK(step(&run) == GSF_OK);
    FUZZ_CHECK(gsf__sample_save(&run) == GSF_OK);
    fuzz_patch_chunks(ctx, (const uint8_t*)saved->data, saved->size, data + 2, size - 2, &file);
    free((void*)(uintptr_t)saved->data);
    gsf_nn_destroy_sampler(ctx, &run.sampler);
    return file;
}

static int all_finite(const float* values, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    if (size < 2) return 0;
    gsf_context ctx = fuzz_context(size);
    fuzz_file files[] = {{"fuzz", NULL, 0}, {NULL, NULL, 0}};
    gsf__sample_run run;
    gsf_nn_schedule schedule;
    float latents[VALUES];
    fuzz_hook_files(&ctx, files);
    FUZZ_CHECK(gsf_nn_make_schedule(&ctx, NULL, &schedule) == GSF_OK);
    gsf_buffer file = make_file(&ctx, &schedule, &files[0], data, size);
    files[0].data = file.data;
    files[0].size = file.size;
    begin(&ctx, &schedule, data[0] % 3, latents, &run);
    FUZZ_CHECK(gsf__sample_resume(&run) == GSF_OK);
    FUZZ_CHECK(run.sampler.index >= 0 && run.sampler.index <= run.sampler.count);
    FUZZ_CHECK(run.stats.resumed_from == run.sampler.index);
    // without patches, the checkpoint fits the job
    FUZZ_CHECK(size > 2 || data[1] >= 128 || run.sampler.index == data[1] % (STEPS + 1));
    FUZZ_CHECK(all_finite(latents, VALUES) && all_finite(run.sampler.memory, run.sampler.memory_count));
    gsf_result result = GSF_OK;
    while (result == GSF_OK && run.sampler.index < run.sampler.count) result = step(&run);
    FUZZ_CHECK(result == GSF_OK ? all_finite(latents, VALUES) : result == GSF_ERROR_NUMERIC);
    gsf_nn_destroy_sampler(&ctx, &run.sampler);
    gsf_nn_destroy_schedule(&ctx, &schedule);
    gsf_destroy_buffer(&ctx, &file);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
