// restorer_pipeline.h - from frames to restored frames: control latents, every step, the decoded video, and variants of
// the release's settings (ten steps, no guidance, dynamic guidance).
#ifndef RESTORER_PIPELINE_H
#define RESTORER_PIPELINE_H

#include "restorer_golden.h"
#include "restorer_transformer.h"

// relative L2: ten times the error of the reference's float32 run
static const double pipeline_bar = 10.0 * 2.5e-6;
static const double pipeline_bf16_bar = 2.0 * 3.0e-2;  // final latents with weights rounded to bf16

typedef struct pipeline_case {
    gsf_context ctx;
    gsf_nn_transformer net;
    gsf_nn_vae vae;
    gsf_nn_schedule schedule;
    test_tensors inputs, expected;
    float *control, *noise, *text, *references, *video;
    gsf_nn_sample_desc desc;
    int compare_steps; // against latents_after_step*
    int seen_latents, seen_prediction; // number of intermediates compared
    float* latents;    // after the last step
} pipeline_case;

// Compares the latents after a step, and the network's (guided) prediction in it.
static void see_step(void* user, const char* what, int32_t step, const float* data, int64_t rows, int64_t columns) {
    pipeline_case* c = (pipeline_case*)user;
    const size_t count = (size_t)(rows * columns);
    char name[64];
    if (strcmp(what, "latents") == 0) {
        memcpy(c->latents, data, count * sizeof(float));
        if (!c->compare_steps) return;
        snprintf(name, sizeof name, "latents_after_step%d", (int)step);
        double* wanted = golden_doubles(&c->expected, name, NULL);
        check_rel_l2(name, data, wanted, count, pipeline_bar);
        free(wanted);
        c->seen_latents++;
    } else if (c->compare_steps && step == 0) { // the file has both predictions, before guidance combines them
        double* halves = golden_doubles(&c->expected, "step0_noise_pred", NULL);
        for (size_t i = 0; i < count; i++) halves[i] += (double)c->desc.guidance * (halves[count + i] - halves[i]);
        check_rel_l2("step0_noise_pred", data, halves, count, pipeline_bar);
        free(halves);
        c->seen_prediction++;
    }
}

// Artifact frames, with the reference images as the first and the last frame: (3, frames, height, width) in [-1,1].
static float* pipeline_control(const pipeline_case* c, int32_t frames, int32_t height, int32_t width) {
    test_tensor artifact = test_get_tensor(&c->inputs, "artifact_frames_u8");
    test_tensor photos = test_get_tensor(&c->inputs, "ref_images_u8");
    const size_t plane = (size_t)height * (size_t)width;
    float* control = (float*)malloc(3 * (size_t)frames * plane * sizeof(float));
    CHECK(artifact.count == 3 * (size_t)frames * plane && photos.count == 6 * plane);
    for (size_t f = 0; f < (size_t)frames; f++) {
        const double* from = f == 0 ? photos.v : f + 1 == (size_t)frames ? photos.v + 3 * plane : artifact.v + f * 3 * plane;
        for (size_t p = 0; p < plane; p++)
            for (size_t k = 0; k < 3; k++)
                control[(k * (size_t)frames + f) * plane + p] = (float)from[p * 3 + k] / 127.5f - 1.0f;
    }
    test_free_tensor(&artifact);
    test_free_tensor(&photos);
    return control;
}

static void run_pipeline(pipeline_case* c, const char* what, const char* wanted_name, double bar) {
    gsf_nn_sample_stats stats;
    CHECK_OK(&c->ctx, gsf_nn_sample(&c->ctx, &c->net, &c->vae, &c->schedule, &c->desc, c->video, &stats));
    CHECK(stats.steps == c->desc.steps);
    CHECK(c->desc.dynamic_guidance || stats.network_rows == (c->desc.guidance == 1.0f ? 1 : 2) * c->desc.steps);
    size_t count;
    double* wanted = golden_doubles(&c->expected, wanted_name, &count);
    check_rel_l2(what, c->latents, wanted, count, bar);
    free(wanted);
}

// decoded_first_mid_last: float output of the first, middle and last frame; frames_u8: all frames as bytes.
static void check_video(const pipeline_case* c) {
    const size_t frames = (size_t)c->desc.frames, plane = (size_t)c->desc.height * (size_t)c->desc.width;
    size_t count, worst = 0, differ = 0;
    double* raw = golden_doubles(&c->expected, "decoded_first_mid_last", &count);
    const size_t shown = count / (3 * plane), at[3] = {0, (frames - 1) / 2, frames - 1};
    float* picked = (float*)malloc(count * sizeof(float));
    CHECK(shown == 3 && frames >= 3);
    for (size_t k = 0; k < 3; k++)
        for (size_t i = 0; i < 3; i++)
            memcpy(picked + (k * 3 + i) * plane, c->video + (k * frames + at[i]) * plane, plane * sizeof(float));
    check_rel_l2("decoded", picked, raw, count, pipeline_bar);
    free(raw);
    free(picked);
    double* bytes = golden_doubles(&c->expected, "frames_u8", &count);
    CHECK(count == 3 * frames * plane);
    for (size_t f = 0; f < frames; f++)
        for (size_t p = 0; p < plane; p++)
            for (size_t k = 0; k < 3; k++) {
                const float v = c->video[(k * frames + f) * plane + p] * 0.5f + 0.5f;
                const double byte = nearbyint((double)(v < 0.0f ? 0.0f : v > 1.0f ? 1.0f : v) * 255.0);
                const size_t error = (size_t)fabs(byte - bytes[(f * plane + p) * 3 + k]);
                differ += error > 0;
                if (error > worst) worst = error;
            }
    CHECK(worst <= 1 && differ <= count / 1000); // values that round to either of two bytes
    free(bytes);
}

static double run_number(const char* text, const char* key, double fallback) {
    char quoted[64];
    snprintf(quoted, sizeof quoted, "\"%s\":", key);
    const char* p = strstr(text, quoted);
    return p ? strtod(p + strlen(quoted), NULL) : fallback;
}

static void check_control(const pipeline_case* c) {
    const int64_t plane = (int64_t)(c->desc.height / c->vae.spatial_ratio) * (c->desc.width / c->vae.spatial_ratio);
    const int64_t frames = (c->desc.frames - 1) / c->vae.temporal_ratio + 1;
    size_t count;
    double* wanted = golden_doubles(&c->expected, "control_mode", &count);
    float* mean = (float*)malloc(count * sizeof(float));
    CHECK(count == (size_t)(frames * plane * c->vae.latent_channels));
    CHECK_OK((gsf_context*)&c->ctx, gsf_nn_encode_vae((gsf_context*)(uintptr_t)&c->ctx, &c->vae, NULL, c->control,
                                                      c->desc.frames, c->desc.height, c->desc.width, mean, NULL));
    check_rel_l2("control_mode", mean, wanted, count, pipeline_bar);
    free(wanted);
    free(mean);
}

static void check_pipeline(void) {
    pipeline_case c;
    memset(&c, 0, sizeof c);
    test_context_init(&c.ctx);
    if (!CHECK_OK(&c.ctx, gsf_nn_load_transformer(&c.ctx, test_golden("restorer/model/transformer"), &c.net)) ||
        !CHECK_OK(&c.ctx, gsf_nn_load_vae(&c.ctx, test_golden("restorer/model/vae"), &c.vae)) ||
        !CHECK_OK(&c.ctx, gsf_nn_load_schedule(&c.ctx, test_golden("restorer/model/scheduler/scheduler_config.json"),
                                               &c.schedule)))
        return;
    c.inputs = test_open_tensors(test_golden("restorer/pipeline/inputs.safetensors"));
    c.expected = test_open_tensors(test_golden("restorer/pipeline/expected.safetensors"));
    char* run = test_read_file(test_golden("restorer/pipeline/run.json"), NULL);
    test_tensor tokens;
    c.desc.frames = (int32_t)run_number(run, "num_frames", 0);
    c.desc.any_frames = 1; // as in the GSFixer release
    c.desc.height = (int32_t)run_number(run, "height", 0);
    c.desc.width = (int32_t)run_number(run, "width", 0);
    c.desc.steps = (int32_t)run_number(run, "num_inference_steps", 0);
    c.desc.guidance = (float)run_number(run, "guidance_scale", 0);
    c.desc.noise = c.noise = golden_floats(&c.inputs, "initial_latents", &tokens);
    c.latents = (float*)malloc(tokens.count * sizeof(float));
    c.desc.control = c.control = pipeline_control(&c, c.desc.frames, c.desc.height, c.desc.width);
    c.desc.text = c.text = golden_floats(&c.expected, "prompt_embeds", NULL);
    float* dino = golden_floats(&c.inputs, "dino_latents", &tokens);
    float* vggt = golden_floats(&c.inputs, "vggt_latents", NULL);
    c.desc.reference_tokens = (int64_t)(tokens.dim[0] * tokens.dim[1]);
    c.references = (float*)malloc((size_t)(c.desc.reference_tokens * c.net.heads * c.net.head_dim) * sizeof(float));
    CHECK_OK(&c.ctx, gsf_nn_project_references(&c.ctx, &c.net, c.desc.reference_tokens, dino, vggt, c.references));
    c.desc.references = c.references;
    c.video = (float*)malloc(3 * (size_t)c.desc.frames * (size_t)c.desc.height * (size_t)c.desc.width * sizeof(float));
    const gsf__nn_tap tap = {see_step, &c};
    c.desc._tap = &tap;

    check_control(&c);
    c.compare_steps = 1;
    run_pipeline(&c, "final latents", "final_latents_f64", pipeline_bar);
    c.compare_steps = 0;
    CHECK(c.seen_latents == c.desc.steps && c.seen_prediction == 1);
    check_video(&c);
    c.desc.no_reference_cache = 1;
    run_pipeline(&c, "final latents without the reference cache", "final_latents_f64", pipeline_bar);
    c.desc.no_reference_cache = 0;
    const gsf_nn_transformer exact = c.net;
    c.net = open_rounded(&c.ctx, test_golden("restorer/model/transformer"));
    run_pipeline(&c, "bf16 weights", "final_latents_f64", pipeline_bf16_bar);
    gsf_nn_destroy_transformer(&c.ctx, &c.net);
    c.net = exact;
    c.desc.dynamic_guidance = 1;
    run_pipeline(&c, "dynamic guidance", "dynamic_cfg.final_latents", pipeline_bar);
    c.desc.dynamic_guidance = 0;
    const float guidance = c.desc.guidance;
    c.desc.guidance = 1.0f;
    run_pipeline(&c, "no guidance", "guidance1.final_latents", pipeline_bar);
    c.desc.guidance = guidance;
    c.desc.steps = 10;
    run_pipeline(&c, "ten steps", "steps10.final_latents", pipeline_bar);

    free(run);
    free(c.noise);
    free(c.latents);
    free(c.control);
    free(c.text);
    free(c.references);
    free(c.video);
    free(dino);
    free(vggt);
    test_close_tensors(&c.inputs);
    test_close_tensors(&c.expected);
    gsf_nn_destroy_schedule(&c.ctx, &c.schedule);
    gsf_nn_destroy_vae(&c.ctx, &c.vae);
    gsf_nn_destroy_transformer(&c.ctx, &c.net);
}

#endif
