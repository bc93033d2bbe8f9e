// restorer_vae.h - encoder and decoder of the video autoencoder against the official code's output.
// Included by golden_restorer.c. Clips, shapes and values are found in GSF_GOLDEN/restorer/vae and model/vae.
#ifndef RESTORER_VAE_H
#define RESTORER_VAE_H

// Ten times the relative L2 error of the official float32 run against its float64 run (vae/README.md).
#define VAE_TOLERANCE 9e-6

static double vae_rel_l2(const float* a, const double* b, size_t count) {
    double difference = 0.0, square = 0.0;
    for (size_t i = 0; i < count; i++) {
        difference += ((double)a[i] - b[i]) * ((double)a[i] - b[i]);
        square += b[i] * b[i];
    }
    return square > 0.0 ? sqrt(difference / square) : sqrt(difference);
}

static void vae_compare(const char* clip, const char* what, const float* actual, const test_tensor* expected) {
    char label[200];
    const double error = vae_rel_l2(actual, expected->v, expected->count);
    snprintf(label, sizeof label, "vae %s.%s: relative L2 error %.3g, allowed %.3g", clip, what, error, VAE_TOLERANCE);
    if (getenv("TEST_VERBOSE")) printf("%s\n", label);
    test_check(error <= VAE_TOLERANCE, label, __FILE__, __LINE__);
}

typedef struct vae_files { test_tensors inputs, f32, f64; } vae_files;

// (frames, height, width, channels) bytes to (channels, frames, height, width) in [-1, 1].
static float* vae_video(const test_tensor* frames) {
    const size_t plane = frames->dim[1] * frames->dim[2], count = frames->dim[0], channels = frames->dim[3];
    float* video = (float*)malloc(frames->count * sizeof(float));
    for (size_t t = 0; t < count; t++)
        for (size_t i = 0; i < plane; i++)
            for (size_t c = 0; c < channels; c++)
                video[(c * count + t) * plane + i] = (float)frames->v[(t * plane + i) * channels + c] / 127.5f - 1.0f;
    return video;
}

// Compares with <clip>.<what> where the file has it; returns whether it had.
static int vae_compare_with(const test_tensors* file, const char* clip, const char* what, const float* actual,
                            size_t count) {
    char name[80];
    snprintf(name, sizeof name, "%s.%s", clip, what);
    test_tensor expected = test_find_tensor(file, name);
    if (!expected.v) return 0;
    if (CHECK(expected.count == count)) vae_compare(clip, what, actual, &expected);
    test_free_tensor(&expected);
    return 1;
}

static void vae_check_sample(const vae_files* files, const char* clip, const float* mean, const float* logvar,
                             size_t count) {
    char name[80];
    snprintf(name, sizeof name, "%s.posterior_noise", clip);
    test_tensor noise = test_find_tensor(&files->inputs, name);
    if (!noise.v) return;
    float* sample = (float*)malloc(count * sizeof(float));
    for (size_t i = 0; i < count; i++) sample[i] = mean[i] + expf(0.5f * logvar[i]) * (float)noise.v[i];
    CHECK(noise.count == count && vae_compare_with(&files->f32, clip, "sample", sample, count));
    free(sample);
    test_free_tensor(&noise);
}

static void vae_check_decode(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files, const char* clip) {
    char name[80];
    gsf_nn_vae_info info;
    snprintf(name, sizeof name, "%s.mean", clip);
    test_tensor mean = test_get_tensor(&files->f32, name);
    snprintf(name, sizeof name, "%s.decoded", clip);
    test_tensor expected = test_get_tensor(&files->f32, name);
    const int64_t f = (int64_t)mean.dim[2], h = (int64_t)mean.dim[3], w = (int64_t)mean.dim[4];
    float* latents = test_tensor_floats(&mean);
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, NULL, f, h, w, &info));
    if (CHECK(info.frames == (int64_t)expected.dim[2] && info.height == (int64_t)expected.dim[3] &&
              info.width == (int64_t)expected.dim[4])) {
        float* video = (float*)malloc(expected.count * sizeof(float));
        CHECK_OK(ctx, gsf_nn_vae_decode(ctx, vae, NULL, latents, f, h, w, video));
        vae_compare(clip, "decoded", video, &expected);
        free(video);
    }
    free(latents);
    test_free_tensor(&mean);
    test_free_tensor(&expected);
}

static void vae_check_clip(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files, const test_tensor* frames) {
    char clip[24];
    gsf_nn_vae_info info;
    snprintf(clip, sizeof clip, "%.*s", (int)strcspn(frames->name, "."), frames->name);
    const int64_t f = (int64_t)frames->dim[0], h = (int64_t)frames->dim[1], w = (int64_t)frames->dim[2];
    float* video = vae_video(frames);
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, NULL, f, h, w, &info));
    const size_t count = (size_t)(vae->latent_channels * info.frames * info.height * info.width);
    float *mean = (float*)malloc(count * sizeof(float)), *logvar = (float*)malloc(count * sizeof(float));
    CHECK_OK(ctx, gsf_nn_vae_encode(ctx, vae, NULL, video, f, h, w, mean, logvar));
    CHECK(vae_compare_with(&files->f32, clip, "mean", mean, count));
    (void)vae_compare_with(&files->f32, clip, "logvar", logvar, count);
    if (vae_compare_with(&files->f64, clip, "mean", mean, count))
        CHECK(vae_compare_with(&files->f64, clip, "logvar", logvar, count));
    vae_check_sample(files, clip, mean, logvar, count);
    vae_check_decode(ctx, vae, files, clip);
    free(video);
    free(mean);
    free(logvar);
}

// Frames 0, 4, 8 of a tiled decode, and frame 8 of the plain one.
static void vae_check_frames(const float* video, const gsf_nn_vae* vae, const gsf_nn_vae_info* info,
                             const test_tensors* file, const char* what, const int64_t* frames, int64_t count) {
    const int64_t plane = info->height * info->width;
    float* picked = (float*)malloc((size_t)(vae->out_channels * count * plane) * sizeof(float));
    for (int64_t c = 0; c < vae->out_channels; c++)
        for (int64_t i = 0; i < count; i++)
            memcpy(picked + (c * count + i) * plane, video + (c * info->frames + frames[i]) * plane,
                   (size_t)plane * sizeof(float));
    CHECK(vae_compare_with(file, "tiled", what, picked, (size_t)(vae->out_channels * count * plane)));
    free(picked);
}

static void vae_check_tiled(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files) {
    static const int64_t frames[3] = {0, 4, 8};
    gsf_nn_vae_desc desc;
    gsf_nn_vae_info info;
    memset(&desc, 0, sizeof desc);
    desc.tiled = 1;
    test_tensor input = test_get_tensor(&files->inputs, "tiled.frames_u8");
    float* video = vae_video(&input);
    int64_t f = (int64_t)input.dim[0], h = (int64_t)input.dim[1], w = (int64_t)input.dim[2];
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, &desc, f, h, w, &info));
    size_t count = (size_t)(vae->latent_channels * info.frames * info.height * info.width);
    float* mean = (float*)malloc(count * sizeof(float));
    CHECK_OK(ctx, gsf_nn_vae_encode(ctx, vae, &desc, video, f, h, w, mean, NULL));
    CHECK(vae_compare_with(&files->f32, "tiled", "mean", mean, count));
    free(video);
    free(mean);
    test_free_tensor(&input);

    test_tensor latent = test_get_tensor(&files->inputs, "tiled.latent");
    float* latents = test_tensor_floats(&latent);
    f = (int64_t)latent.dim[2], h = (int64_t)latent.dim[3], w = (int64_t)latent.dim[4];
    for (desc.tiled = 0; desc.tiled < 2; desc.tiled++) {
        CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, &desc, f, h, w, &info));
        if (!CHECK(info.frames > 8)) break;
        video = (float*)malloc((size_t)(vae->out_channels * info.frames * info.height * info.width) * sizeof(float));
        CHECK_OK(ctx, gsf_nn_vae_decode(ctx, vae, &desc, latents, f, h, w, video));
        if (desc.tiled) vae_check_frames(video, vae, &info, &files->f32, "decoded_frames_0_4_8", frames, 3);
        else vae_check_frames(video, vae, &info, &files->f32, "plain_decoded_frame8", frames + 2, 1);
        free(video);
    }
    free(latents);
    test_free_tensor(&latent);
}

// Every tensor `clipN.frames_u8` of the inputs.
static void vae_check_clips(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files) {
    int clips = 0;
    for (int n = 1; n <= 200; n++) {
        char name[40];
        snprintf(name, sizeof name, "clip%d.frames_u8", n);
        test_tensor frames = test_find_tensor(&files->inputs, name);
        if (!frames.v) continue;
        vae_check_clip(ctx, vae, files, &frames);
        test_free_tensor(&frames);
        clips++;
    }
    CHECK(clips > 0);
}

static void check_vae(void) {
    gsf_context ctx;
    gsf_nn_vae vae;
    vae_files files;
    test_context_init(&ctx);
    files.inputs = test_open_tensors(test_golden("restorer/vae/inputs.safetensors"));
    files.f32 = test_open_tensors(test_golden("restorer/vae/expected_f32.safetensors"));
    files.f64 = test_open_tensors(test_golden("restorer/vae/expected_f64.safetensors"));
    if (CHECK_OK(&ctx, gsf_nn_make_vae(&ctx, test_golden("restorer/model/vae"), &vae))) {
        vae_check_clips(&ctx, &vae, &files);
        vae_check_tiled(&ctx, &vae, &files);
        gsf_nn_destroy_vae(&ctx, &vae);
    }
    test_close_tensors(&files.inputs);
    test_close_tensors(&files.f32);
    test_close_tensors(&files.f64);
}

#endif
