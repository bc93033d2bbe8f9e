// restorer_vae.h - encoder and decoder of the video autoencoder against the output of diffusers.
// Included by golden_restorer.c. Clips, shapes and values are read from GSF_GOLDEN/restorer/vae and model/vae.
#ifndef RESTORER_VAE_H
#define RESTORER_VAE_H

// Ten times the relative L2 error of the float32 run of diffusers against its float64 run (vae/README.md).
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

// Compares with <clip>.<what> if the file contains it; returns whether it does.
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
        CHECK_OK(ctx, gsf_nn_decode_vae(ctx, vae, NULL, latents, f, h, w, video));
        vae_compare(clip, "decoded", video, &expected);
        free(video);
    }
    free(latents);
    test_free_tensor(&mean);
    test_free_tensor(&expected);
}

static void vae_check_clip(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files, const test_tensor* frames) {
    char clip[64];
    gsf_nn_vae_info info;
    snprintf(clip, sizeof clip, "%.*s", (int)strcspn(frames->name, "."), frames->name);
    const int64_t f = (int64_t)frames->dim[0], h = (int64_t)frames->dim[1], w = (int64_t)frames->dim[2];
    float* video = vae_video(frames);
    CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, NULL, f, h, w, &info));
    const size_t count = (size_t)(vae->latent_channels * info.frames * info.height * info.width);
    float *mean = (float*)malloc(count * sizeof(float)), *logvar = (float*)malloc(count * sizeof(float));
    CHECK_OK(ctx, gsf_nn_encode_vae(ctx, vae, NULL, video, f, h, w, mean, logvar));
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
    CHECK_OK(ctx, gsf_nn_encode_vae(ctx, vae, &desc, video, f, h, w, mean, NULL));
    CHECK(vae_compare_with(&files->f32, "tiled", "mean", mean, count));
    free(video);
    free(mean);
    test_free_tensor(&input);

    test_tensor latent = test_get_tensor(&files->inputs, "tiled.latent");
    float* latents = test_tensor_floats(&latent);
    f = (int64_t)latent.dim[2], h = (int64_t)latent.dim[3], w = (int64_t)latent.dim[4];
    for (desc.tiled = 0; desc.tiled < 2; desc.tiled++) {
        CHECK_OK(ctx, gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, &desc, f, h, w, &info));
        // followed by frame numbers: 0_4_8
        const char* prefix = desc.tiled ? "tiled.decoded_frames_" : "tiled.plain_decoded_frame";
        char numbers[64], what[96];
        int64_t frames[16], picked = 0;
        size_t at = 0;
        if (!CHECK(numerics_next(&files->f32, prefix, "", &at, numbers))) break;
        for (char* p = numbers; *p && picked < 16; p += *p == '_') {
            frames[picked] = strtol(p, &p, 10);
            if (!CHECK((*p == '_' || !*p) && frames[picked] >= 0 && frames[picked] < info.frames)) return;
            picked++;
        }
        snprintf(what, sizeof what, "%s%s", prefix + strlen("tiled."), numbers);
        video = (float*)malloc((size_t)(vae->out_channels * info.frames * info.height * info.width) * sizeof(float));
        CHECK_OK(ctx, gsf_nn_decode_vae(ctx, vae, &desc, latents, f, h, w, video));
        vae_check_frames(video, vae, &info, &files->f32, what, frames, picked);
        free(video);
    }
    free(latents);
    test_free_tensor(&latent);
}

// ---- intermediates: "dec.up0.chunk1" is the output of the decoder's up block 0 for the second chunk

typedef struct vae_watcher {
    const test_tensors* file;
    const gsf_nn_vae* vae;
    const char* clip;
    int decoder, seen;
    int trial;    // only determines whether the intermediates are of this clip
    double worst; // of such a trial
} vae_watcher;

// Name, in the weight file, of the layer whose output is the intermediate `part`.
static void vae_layer_name(const vae_watcher* w, const char* part, char* out, size_t room) {
    const char* side = w->decoder ? "decoder" : "encoder";
    const int level = atoi(part + strcspn(part, "0123456789")), last = w->vae->layers_per_block - 1;
    if (strncmp(part, "conv_in", 7) == 0) snprintf(out, room, "%s.conv_in.conv.weight", side);
    else if (strcmp(part, "mid") == 0) snprintf(out, room, "%s.mid_block.resnets.1.conv2.conv.weight", side);
    else if (strcmp(part, "norm_out") == 0)
        snprintf(out, room, w->decoder ? "%s.norm_out.norm_layer.weight" : "%s.norm_out.weight", side);
    else if (strcmp(part, "mid.resnet0.norm1") == 0)
        snprintf(out, room, "%s.mid_block.resnets.0.norm1%s.weight", side, w->decoder ? ".norm_layer" : "");
    else if (level < w->vae->levels - 1)
        snprintf(out, room, "%s.%s_blocks.%d.%ssamplers.0.conv.weight", side, w->decoder ? "up" : "down", level,
                 w->decoder ? "up" : "down");
    else
        snprintf(out, room, "%s.%s_blocks.%d.resnets.%d.conv2.conv.weight", side, w->decoder ? "up" : "down", level,
                 last + w->decoder);
}

// (frames, height, width, channels), or one bordered frame of it, against (channels, frames, height, width).
static void vae_compare_map(vae_watcher* w, const char* what, const gsf__vae_map* map, int64_t frame, const float* data) {
    test_tensor expected = test_get_tensor(w->file, what);
    const int64_t plane = map->height * map->width, border = frame < 0 ? 0 : 1;
    const int64_t first = frame < 0 ? 0 : frame, frames = frame < 0 ? map->frames : 1;
    const int64_t count = frames * plane * map->channels;
    if ((int64_t)expected.count != map->frames * plane * map->channels) {
        CHECK(w->trial);
        w->worst = INFINITY;
        test_free_tensor(&expected);
        return;
    }
    float* planes = (float*)malloc((size_t)count * sizeof(float));
    double* part = (double*)malloc((size_t)count * sizeof(double));
    int64_t n = 0;
    for (int64_t c = 0; c < map->channels; c++)
        for (int64_t t = 0; t < frames; t++)
            for (int64_t i = 0; i < plane; i++, n++) {
                const int64_t row = i / map->width, column = i % map->width + border;
                const double e = expected.v[(c * map->frames + first + t) * plane + i];
                planes[n] = data[((t * map->height + row) * (map->width + 2 * border) + column) * map->channels + c];
                part[n] = frame < 0 ? e : e / (1.0 + exp(-e)); // the file has norms before SiLU is applied
            }
    test_tensor picked = expected;
    picked.v = part;
    picked.count = (size_t)count;
    if (w->trial) w->worst = fmax(w->worst, vae_rel_l2(planes, part, (size_t)count));
    else vae_compare(w->clip, what, planes, &picked);
    free(planes);
    free(part);
    test_free_tensor(&expected);
    w->seen++;
}

static void vae_watch(void* user, const gsf_nn_tensor* weight, int64_t chunk, const gsf__vae_map* map, int64_t frame,
                      const float* data) {
    static const char* const parts[] = {"conv_in", "mid", "mid.resnet0.norm1", "norm_out", "up0", "up1", "up2", "up3",
                                        "down0", "down1", "down2", "down3"};
    vae_watcher* w = (vae_watcher*)user;
    for (size_t i = 0; i < sizeof parts / sizeof *parts; i++) {
        char what[80], layer[120], key[96];
        vae_layer_name(w, parts[i], layer, sizeof layer);
        if (strcmp(layer, weight->name) != 0) continue;
        snprintf(what, sizeof what, "%s.%s.chunk%d", w->decoder ? "dec" : "enc", parts[i], (int)chunk);
        snprintf(key, sizeof key, "\"%s\"", what);
        if (strstr(w->file->data + 8, key)) vae_compare_map(w, what, map, frame, data);
    }
}

// Runs both halves of the network on a clip and compares the intermediates; returns the worst error of a trial.
static double vae_watch_clip(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files, const test_tensors* file,
                             const char* clip, int trial) {
    char name[80];
    snprintf(name, sizeof name, "%s.frames_u8", clip);
    test_tensor frames = test_get_tensor(&files->inputs, name);
    snprintf(name, sizeof name, "%s.mean", clip);
    test_tensor mean = test_get_tensor(&files->f32, name);
    float *in[2], *out = NULL, *moments = (float*)malloc(mean.count * 2 * sizeof(float));
    double worst = 0.0;
    in[0] = vae_video(&frames);
    in[1] = test_tensor_floats(&mean);
    for (int decoder = 0; decoder < 2; decoder++) {
        gsf__vae_task task;
        gsf_nn_vae_info info;
        double flops, bytes;
        vae_watcher watcher = {file, vae, clip, decoder, 0, trial, 0.0};
        const size_t* size = decoder ? mean.dim + 2 : frames.dim;
        const int64_t f = (int64_t)size[0], h = (int64_t)size[1], w = (int64_t)size[2];
        CHECK_OK(ctx, gsf__vae_make_task(ctx, vae, decoder, NULL, f, h, w, &task, &info));
        task.watch.fn = vae_watch;
        task.watch.user = &watcher;
        out = (float*)malloc((size_t)(vae->out_channels * info.frames * info.height * info.width) * sizeof(float));
        CHECK_OK(ctx, gsf__vae_execute(ctx, &task, in[decoder], out, moments, NULL, &flops, &bytes));
        CHECK(trial || watcher.seen > 4);
        CHECK_NEAR(flops, info.flops, 0.0);
        CHECK_NEAR(bytes, info.bytes, 0.0);
        worst = fmax(worst, watcher.worst);
        free(out);
    }
    free(in[0]);
    free(in[1]);
    free(moments);
    test_free_tensor(&frames);
    test_free_tensor(&mean);
    return worst;
}

// The next clip of the inputs; skips the inputs for tiles, which are not a clip of their own.
static int vae_next_clip(const vae_files* files, size_t* at, char name[64]) {
    while (numerics_next(&files->inputs, "", ".frames_u8", at, name))
        if (strcmp(name, "tiled") != 0) return 1;
    return 0;
}

// The intermediates do not say which clip they are of: they are compared with the clip that fits best.
static void vae_check_intermediates(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files) {
    test_tensors file = test_open_tensors(test_golden("restorer/vae/intermediates_f32.safetensors"));
    char name[64], best[64] = "";
    double least = INFINITY;
    for (size_t at = 0; vae_next_clip(files, &at, name);) {
        const double worst = vae_watch_clip(ctx, vae, files, &file, name, 1);
        if (!(worst < least)) continue;
        least = worst;
        snprintf(best, sizeof best, "%s", name);
    }
    if (CHECK(best[0])) (void)vae_watch_clip(ctx, vae, files, &file, best, 0);
    test_close_tensors(&file);
}

static void vae_check_clips(gsf_context* ctx, const gsf_nn_vae* vae, const vae_files* files) {
    char clip[64], name[80];
    int clips = 0;
    for (size_t at = 0; vae_next_clip(files, &at, clip); clips++) {
        snprintf(name, sizeof name, "%s.frames_u8", clip);
        test_tensor frames = test_get_tensor(&files->inputs, name);
        vae_check_clip(ctx, vae, files, &frames);
        test_free_tensor(&frames);
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
    if (CHECK_OK(&ctx, gsf_nn_load_vae(&ctx, test_golden("restorer/model/vae"), &vae))) {
        vae_check_clips(&ctx, &vae, &files);
        vae_check_tiled(&ctx, &vae, &files);
        vae_check_intermediates(&ctx, &vae, &files);
        gsf_nn_destroy_vae(&ctx, &vae);
    }
    test_close_tensors(&files.inputs);
    test_close_tensors(&files.f32);
    test_close_tensors(&files.f64);
}

#endif
