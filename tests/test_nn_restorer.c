// The restorer `dit` behind gsfixer.h's interface, on the small golden model: what it accepts, what it skips, workers,
// cancelling and resuming, weights and features that are wrong.
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

enum { MAX_FRAMES = 9 };

typedef struct clip {
    int32_t frames, width, height;
    gsf_image color[MAX_FRAMES], out[MAX_FRAMES], confidence[MAX_FRAMES];
    int32_t reference_index[MAX_FRAMES];
    gsf_restore_window window;
} clip;

static const char* model_folder(void) { return test_golden("restorer/model"); }

// The features of the golden pipeline in one file, as --ref-features takes it; `without` leaves a tensor out.
static const char* write_features(gsf_context* ctx, const char* name, const char* without) {
    const char* path = test_scratch(name);
    gsf_nn_weights inputs, expected;
    CHECK_OK(ctx, gsf_nn_open_weights(ctx, test_golden("restorer/pipeline/inputs.safetensors"), NULL, &inputs));
    CHECK_OK(ctx, gsf_nn_open_weights(ctx, test_golden("restorer/pipeline/expected.safetensors"), NULL, &expected));
    const gsf_tensor* const all[] = {gsf_nn_find_tensor(&inputs, "dino_latents"),
                                     gsf_nn_find_tensor(&inputs, "vggt_latents"),
                                     gsf_nn_find_tensor(&expected, "prompt_embeds")};
    gsf_tensor tensors[3];
    size_t count = 0;
    for (int i = 0; i < 3; i++)
        if (CHECK(all[i] != NULL) && !(without && strcmp(all[i]->name, without) == 0)) tensors[count++] = *all[i];
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, count));
    gsf_nn_close_weights(ctx, &inputs);
    gsf_nn_close_weights(ctx, &expected);
    return path;
}

static void make_clip(gsf_context* ctx, clip* c, int32_t frames, int32_t width, int32_t height) {
    uint64_t state = 5;
    memset(c, 0, sizeof *c);
    c->frames = frames;
    c->width = width;
    c->height = height;
    for (int32_t f = 0; f < frames; f++) {
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 3, &c->color[f]));
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 3, &c->out[f]));
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, width, height, 1, &c->confidence[f]));
        float* v = (float*)c->color[f].data;
        for (int32_t i = 0; i < 3 * width * height; i++) v[i] = (float)test_random(&state);
        c->reference_index[f] = -1;
    }
    c->window.struct_size = sizeof c->window;
    c->window.frame_count = frames;
    c->window.color = c->color;
    c->window.reference_index = c->reference_index;
    c->window.seed = 7;
    c->window.out_color = c->out;
    c->window.out_confidence = c->confidence;
}

static void free_clip(gsf_context* ctx, clip* c) {
    for (int32_t f = 0; f < c->frames; f++) {
        gsf_destroy_image(ctx, &c->color[f]);
        gsf_destroy_image(ctx, &c->out[f]);
        gsf_destroy_image(ctx, &c->confidence[f]);
    }
}

static uint32_t checksum(const clip* c) { // FNV-1a
    uint32_t sum = 2166136261u;
    for (int32_t f = 0; f < c->frames; f++)
        for (size_t i = 0; i < (size_t)(3 * c->width * c->height) * sizeof(float); i++)
            sum = (sum ^ ((const unsigned char*)c->out[f].data)[i]) * 16777619u;
    return sum;
}

static gsf_nn_dit_desc small_desc(const char* features, int32_t steps) {
    gsf_nn_dit_desc d;
    memset(&d, 0, sizeof d);
    d.model = model_folder();
    d.features = features;
    d.sample.steps = steps;
    return d;
}

// One clip through a restorer of this desc; the checksum of what comes out, 0 when it failed.
static uint32_t restore(gsf_context* ctx, const gsf_nn_dit_desc* desc, clip* c, gsf_result wanted) {
    gsf_restorer r;
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, desc, &r))) return 0;
    CHECK_OK(ctx, r.begin_fn(r.user, ctx, NULL, 0));
    const int ok = CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), wanted) && wanted == GSF_OK;
    r.end_fn(r.user, ctx);
    gsf_nn_destroy_dit(ctx, &r);
    return ok ? checksum(c) : 0;
}

static void test_limits(gsf_context* ctx, const char* features, clip* c) {
    const gsf_nn_dit_desc desc = small_desc(features, 2);
    gsf_restorer r;
    gsf_restorer_limits limits;
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) return;
    CHECK(r.struct_size == sizeof r && strcmp(r.name, "dit") == 0);
    CHECK_OK(ctx, r.query_fn(r.user, ctx, c->frames, c->width, c->height, &limits));
    CHECK(limits.frame_count_min == 9 && limits.frame_count_step == 8 && limits.frame_count_max >= 9);
    CHECK(limits.width_multiple == c->width && limits.height_multiple == c->height); // learned positions: one size
    CHECK(limits.bytes > 0.0 && limits.flops > 0.0 && !limits.needs_depth && !limits.needs_alpha);
    CHECK_OK(ctx, r.query_fn(r.user, ctx, 10, c->width + 1, c->height, &limits)); // not legal: no cost, but limits
    CHECK(limits.bytes == 0.0 && limits.frame_count_min == 9);
    CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
    for (int32_t f = 0; f < c->frames; f++)
        for (int32_t i = 0; i < c->width * c->height; i++) {
            const float* v = (const float*)c->out[f].data + 3 * i;
            if (!(v[0] >= 0.0f && v[0] <= 1.0f && ((const float*)c->confidence[f].data)[i] == 1.0f)) {
                CHECK(!"frames in [0,1], confidence 1");
                f = c->frames - 1;
                break;
            }
        }
    c->window.frame_count = 8;
    CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), GSF_ERROR_UNSUPPORTED);
    c->window.frame_count = c->frames;
    gsf_nn_destroy_dit(ctx, &r);
    gsf_nn_destroy_dit(ctx, &r); // twice is fine
}

// A frame that is a reference's view is replaced by the photo.
static void test_references(gsf_context* ctx, const char* features, clip* c) {
    const gsf_nn_dit_desc desc = small_desc(features, 2);
    gsf_restorer r;
    gsf_reference photo;
    memset(&photo, 0, sizeof photo);
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) return;
    CHECK_OK(ctx, r.begin_fn(r.user, ctx, NULL, 0));
    CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
    r.end_fn(r.user, ctx);
    const uint32_t plain = checksum(c);
    photo.color = c->color[3];
    c->reference_index[0] = 0;
    CHECK_OK(ctx, r.begin_fn(r.user, ctx, &photo, 1));
    CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
    r.end_fn(r.user, ctx);
    const uint32_t with_photo = checksum(c);
    c->reference_index[0] = -1;
    const gsf_image first = c->color[0];
    c->color[0] = c->color[3];
    CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
    c->color[0] = first;
    CHECK(with_photo != plain && with_photo == checksum(c));
    gsf_nn_destroy_dit(ctx, &r);
}

// A photo of twice the size, of which the frame's camera sees all but 8 columns, and as many beyond its other side.
static void test_cropped_reference(gsf_context* ctx, const char* features, clip* c) {
    const gsf_nn_dit_desc desc = small_desc(features, 1);
    gsf_restorer r;
    gsf_reference photo;
    gsf_camera cameras[MAX_FRAMES];
    const gsf_image frame = c->color[0];
    gsf_image seen;
    memset(&photo, 0, sizeof photo);
    memset(cameras, 0, sizeof cameras);
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, 2 * c->width, 2 * c->height, 3, &photo.color));
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, c->width, c->height, 3, &seen));
    float *large = (float*)photo.color.data, *small = (float*)seen.data;
    for (int64_t y = 0; y < 2 * c->height; y++)
        for (int64_t x = 0; x < 6 * c->width; x++)
            large[y * 6 * c->width + x] = ((const float*)c->color[3].data)[y / 2 * 3 * c->width + x / 6 * 3 + x % 3];
    for (int64_t y = 0; y < c->height; y++)
        for (int64_t x = 0; x < 3 * c->width; x++) {
            const float* from = (const float*)(x >= 3 * (c->width - 8) ? frame.data : c->color[3].data);
            small[y * 3 * c->width + x] = from[y * 3 * c->width + (x >= 3 * (c->width - 8) ? x : x + 24)];
        }
    photo.camera.fx = photo.camera.fy = 200.0;
    photo.camera.cx = c->width;
    photo.camera.cy = c->height;
    for (int32_t i = 0; i < c->frames; i++) {
        cameras[i].fx = cameras[i].fy = 100.0;
        cameras[i].cx = 0.5 * c->width - 8.0;
        cameras[i].cy = 0.5 * c->height;
    }
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) return;
    c->window.cameras = cameras;
    c->reference_index[0] = 0;
    CHECK_OK(ctx, r.begin_fn(r.user, ctx, &photo, 1));
    gsf_destroy_image(ctx, &photo.color); // only borrowed
    CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
    r.end_fn(r.user, ctx);
    const uint32_t with_photo = checksum(c);
    c->window.cameras = NULL;
    c->reference_index[0] = -1;
    c->color[0] = seen;
    CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
    CHECK(checksum(c) == with_photo);
    c->color[0] = frame;
    gsf_destroy_image(ctx, &seen);
    gsf_nn_destroy_dit(ctx, &r);
}

// Every condition gives something else; leaving the cache of the references' keys out changes no bit.
static void test_conditions(gsf_context* ctx, const char* features, clip* c) {
    uint32_t sums[4];
    for (int i = 0; i < 4; i++) {
        gsf_nn_dit_desc desc = small_desc(features, 2);
        desc.condition = (gsf_nn_condition)i;
        sums[i] = restore(ctx, &desc, c, GSF_OK);
        for (int j = 0; j < i; j++) CHECK(sums[i] != sums[j]);
        desc.sample.no_reference_cache = 1;
        CHECK(restore(ctx, &desc, c, GSF_OK) == sums[i]);
    }
    const char* no_vggt = write_features(ctx, "no_vggt.safetensors", "vggt_latents");
    gsf_nn_dit_desc desc = small_desc(no_vggt, 2);
    desc.condition = GSF_NN_2D;
    CHECK(restore(ctx, &desc, c, GSF_OK) == sums[GSF_NN_2D]); // what is not asked for need not be there
    gsf_restorer r;
    desc.condition = GSF_NN_BOTH;
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_IO); // the folder has no encoder, either
    CHECK(strstr(ctx->error, "/vggt/") != NULL && strstr(ctx->error, "vggt_latents") != NULL && r.user == NULL);
}

// Prompts by the folder's tokenizer and text encoder; what is saved of them does without both.
static void test_prompts(gsf_context* ctx, const char* features, clip* c) {
    char saved[1100];
    gsf_nn_dit_desc desc = small_desc(write_features(ctx, "no_text.safetensors", "prompt_embeds"), 2);
    gsf_restorer r;
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_IO); // no caption, and no captioner
    CHECK(strstr(ctx->error, "/blip2/") != NULL && strstr(ctx->error, "a caption") != NULL && r.user == NULL);
    snprintf(saved, sizeof saved, "%s", test_scratch("saved.safetensors"));
    desc.caption = "a wall";
    desc.save_features = saved;
    const uint32_t wall = restore(ctx, &desc, c, GSF_OK);
    const gsf_nn_dit_desc again = small_desc(saved, 2);
    CHECK(restore(ctx, &again, c, GSF_OK) == wall);
    desc.caption = "a view of trees";
    CHECK(restore(ctx, &desc, c, GSF_OK) != wall);
    desc.features = features; // prompts from the file count more than a caption
    const gsf_nn_dit_desc plain = small_desc(features, 2);
    CHECK(restore(ctx, &desc, c, GSF_OK) == restore(ctx, &plain, c, GSF_OK));
    desc.features = NULL;
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_IO);
    CHECK(strstr(ctx->error, "/dinov2/") != NULL && strstr(ctx->error, "dino_latents") != NULL);
    desc.condition = GSF_NN_NONE;
    CHECK(restore(ctx, &desc, c, GSF_OK) != 0);
    desc.model = test_golden("restorer/model/transformer"); // names the part that is missing first
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_IO);
}

typedef struct sample_case {
    gsf_nn_transformer net;
    gsf_nn_vae vae;
    gsf_nn_schedule schedule;
    gsf_nn_sample_desc desc;
    float *control, *text, *video;
    size_t values;
} sample_case;

static void open_sample(gsf_context* ctx, sample_case* s) {
    char path[1200];
    memset(s, 0, sizeof *s);
    snprintf(path, sizeof path, "%s/transformer", model_folder());
    CHECK_OK(ctx, gsf_nn_make_transformer(ctx, path, &s->net));
    snprintf(path, sizeof path, "%s/vae", model_folder());
    CHECK_OK(ctx, gsf_nn_make_vae(ctx, path, &s->vae));
    snprintf(path, sizeof path, "%s/scheduler/scheduler_config.json", model_folder());
    CHECK_OK(ctx, gsf_nn_load_schedule(ctx, path, &s->schedule));
    s->desc.frames = 9;
    s->desc.height = s->net.sample_height * s->vae.spatial_ratio;
    s->desc.width = s->net.sample_width * s->vae.spatial_ratio;
    s->values = 3 * 9 * (size_t)s->desc.height * (size_t)s->desc.width;
    const size_t text = 2 * (size_t)s->net.text_tokens * (size_t)s->net.text_channels;
    s->control = (float*)malloc(s->values * sizeof(float));
    s->video = (float*)malloc(s->values * sizeof(float));
    s->text = (float*)malloc(text * sizeof(float));
    uint64_t state = 11;
    for (size_t i = 0; i < s->values; i++) s->control[i] = (float)test_random_in(&state, -1.0, 1.0);
    for (size_t i = 0; i < text; i++) s->text[i] = (float)test_random_in(&state, -1.0, 1.0);
    s->desc.control = s->control;
    s->desc.text = s->text;
}

static void close_sample(gsf_context* ctx, sample_case* s) {
    gsf_nn_destroy_transformer(ctx, &s->net);
    gsf_nn_destroy_vae(ctx, &s->vae);
    gsf_nn_destroy_schedule(ctx, &s->schedule);
    free(s->control);
    free(s->text);
    free(s->video);
}

static gsf_nn_sample_stats run_sample(gsf_context* ctx, sample_case* s, float* video) {
    gsf_nn_sample_stats stats;
    memset(&stats, 0, sizeof stats);
    CHECK_OK(ctx, gsf_nn_sample(ctx, &s->net, &s->vae, &s->schedule, &s->desc, video, &stats));
    return stats;
}

static double difference(const float* a, const float* b, size_t count) { // relative L2
    double error = 0.0, norm = 0.0;
    for (size_t i = 0; i < count; i++) {
        error += ((double)a[i] - (double)b[i]) * ((double)a[i] - (double)b[i]);
        norm += (double)b[i] * (double)b[i];
    }
    return sqrt(error / norm);
}

static void test_skips(gsf_context* ctx, sample_case* s) {
    float* reference = (float*)malloc(s->values * sizeof(float));
    s->desc.steps = 8;
    gsf_nn_sample_stats stats = run_sample(ctx, s, reference);
    CHECK(stats.steps == 8 && stats.network_rows == 16 && stats.cached_steps == 0);

    s->desc.guidance_begin = 0.25f; // half of the steps guided
    s->desc.guidance_end = 0.75f;
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.network_rows == 12 && difference(s->video, reference, s->values) > 1e-4);
    s->desc.guidance_begin = s->desc.guidance_end = 0.0f;

    s->desc.block_cache = 1e-9f; // so small that no step is like the last one: the same bits as without
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.cached_steps == 0 && memcmp(s->video, reference, s->values * sizeof(float)) == 0);
    s->desc.block_cache = 0.8f; // with random weights the steps are not much alike
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.cached_steps > 0 && stats.cached_steps < 8);
    CHECK(difference(s->video, reference, s->values) < 1.0);
    s->desc.block_cache = 0.0f;

    s->desc.strength = 0.5f; // the last half of the schedule, from the noised control frames
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.steps == 4 && stats.network_rows == 8);
    s->desc.strength = 0.0f;

    for (int solver = GSF_NN_DDIM; solver <= GSF_NN_UNIPC; solver++) { // all near each other with many steps
        s->desc.solver = (gsf_nn_solver)solver;
        s->desc.steps = 40;
        run_sample(ctx, s, solver ? s->video : reference);
        if (solver) CHECK(difference(s->video, reference, s->values) < 0.2);
    }
    s->desc.solver = GSF_NN_DDIM;
    s->desc.steps = 0;
    free(reference);
}

static void test_bad_sample(gsf_context* ctx, sample_case* s) {
    const gsf_nn_sample_desc good = s->desc;
    gsf_nn_cost cost;
#define EXPECT(result, text)                                                                                       \
    CHECK_RESULT(ctx, gsf_nn_sample(ctx, &s->net, &s->vae, &s->schedule, &s->desc, s->video, NULL), result);       \
    CHECK(strstr(ctx->error, text) != NULL);                                                                       \
    s->desc = good
    s->desc.frames = 13; EXPECT(GSF_ERROR_UNSUPPORTED, "13 frames");
    s->desc.width = 40; EXPECT(GSF_ERROR_UNSUPPORTED, "40 x");
    s->desc.width += 16; EXPECT(GSF_ERROR_UNSUPPORTED, "learned positions");
    s->desc.control = NULL; EXPECT(GSF_ERROR_INVALID_ARGUMENT, "missing");
    s->desc.steps = -1; EXPECT(GSF_ERROR_INVALID_ARGUMENT, "steps");
    s->desc.strength = 1.5f; EXPECT(GSF_ERROR_INVALID_ARGUMENT, "strength");
    s->desc.guidance = 0.5f; EXPECT(GSF_ERROR_INVALID_ARGUMENT, "guidance");
    s->desc.max_bytes = 1e4; EXPECT(GSF_ERROR_OUT_OF_MEMORY, "need 0.0");
    s->desc._end_canary = 3; EXPECT(GSF_ERROR_INVALID_ARGUMENT, "zeroed");
    s->desc.checkpoint = test_scratch("no/such/folder"); EXPECT(GSF_ERROR_IO, "no/such/folder");
#undef EXPECT
    const float kept = s->text[3];
    s->text[3] = NAN;
    CHECK_RESULT(ctx, gsf_nn_sample(ctx, &s->net, &s->vae, &s->schedule, &s->desc, s->video, NULL), GSF_ERROR_NUMERIC);
    CHECK(strstr(ctx->error, "embedding") != NULL);
    s->text[3] = kept;
    CHECK_OK(ctx, gsf_nn_sample_cost(ctx, &s->net, &s->vae, &s->desc, &cost));
    CHECK(cost.bytes > 1e5 && cost.flops > 1e9);
}

// A NaN in a weight is named, with the block where it shows.
static void test_bad_weight(gsf_context* ctx, sample_case* s) {
    const char* name = "transformer_blocks.1.ff.net.2.weight";
    gsf_tensor* tensor = NULL;
    for (size_t i = 0; i < s->net.weights.tensor_count; i++)
        if (strcmp(s->net.weights.tensors[i].name, name) == 0) tensor = &s->net.weights.tensors[i];
    if (!CHECK(tensor != NULL)) return;
    const size_t bytes = (size_t)tensor->count * gsf_nn_dtype_size(tensor->dtype);
    char* copy = (char*)malloc(bytes);
    const void* mapped = tensor->data;
    memcpy(copy, mapped, bytes);
    memset(copy + bytes / 2 / 4 * 4, 0xff, 4);
    tensor->data = copy;
    CHECK_RESULT(ctx, gsf_nn_sample(ctx, &s->net, &s->vae, &s->schedule, &s->desc, s->video, NULL), GSF_ERROR_NUMERIC);
    CHECK(strstr(ctx->error, name) != NULL);
    tensor->data = mapped;
    free(copy);
}

typedef struct stopper { gsf_context* ctx; int after; } stopper;
static void stop_at(void* user, const char* stage, double done, double total) {
    stopper* s = (stopper*)user;
    (void)total;
    if (strcmp(stage, "restore") == 0 && done >= s->after) gsf_request_cancel(s->ctx);
}

static void test_resume(gsf_context* ctx, sample_case* s) {
    float* reference = (float*)malloc(s->values * sizeof(float));
    const char* path = test_scratch("sample.checkpoint");
    for (int solver = GSF_NN_DDIM; solver <= GSF_NN_UNIPC; solver++) {
        remove(path);
        s->desc.solver = (gsf_nn_solver)solver;
        s->desc.steps = 6;
        s->desc.checkpoint = NULL;
        run_sample(ctx, s, reference);
        s->desc.checkpoint = path;
        stopper stop = {ctx, 3};
        ctx->progress.progress_fn = stop_at;
        ctx->progress.user = &stop;
        CHECK_RESULT(ctx, gsf_nn_sample(ctx, &s->net, &s->vae, &s->schedule, &s->desc, s->video, NULL),
                     GSF_ERROR_CANCELLED);
        memset(&ctx->progress, 0, sizeof ctx->progress);
        gsf_clear_cancel(ctx);
        gsf_nn_sample_stats stats = run_sample(ctx, s, s->video);
        CHECK(stats.resumed_from == 3 && stats.steps == 3);
        CHECK(memcmp(s->video, reference, s->values * sizeof(float)) == 0);
        stats = run_sample(ctx, s, s->video); // nothing is left to do but to decode
        CHECK(stats.steps == 0 && memcmp(s->video, reference, s->values * sizeof(float)) == 0);
        s->desc.seed++; // another job: the file does not fit
        stats = run_sample(ctx, s, s->video);
        CHECK(stats.resumed_from == 0 && stats.steps == 6);
        s->desc.seed--;
        CHECK_OK(ctx, gsf_write_file(ctx, path, "GSFCHUNKgarbage", 15)); // a broken one neither
        stats = run_sample(ctx, s, s->video);
        CHECK(stats.resumed_from == 0 && memcmp(s->video, reference, s->values * sizeof(float)) == 0);
    }
    s->desc.checkpoint = NULL;
    s->desc.solver = GSF_NN_DDIM;
    s->desc.steps = 0;
    free(reference);
}

static void test_workers(const char* features, clip* c) {
    uint32_t sums[2];
    for (int k = 0; k < 2; k++) {
        gsf_context ctx;
        test_context_zero(&ctx);
        ctx.threads = 1;
        if (k) work_backwards(&ctx);
        if (gsf_init_context(&ctx) != GSF_OK) exit(2);
        const gsf_nn_dit_desc desc = small_desc(features, 2);
        sums[k] = restore(&ctx, &desc, c, GSF_OK);
    }
    CHECK(sums[0] == sums[1]);
}

static void test_memory(const char* features, clip* c) { // each of the first ten allocations fails, then some later ones
    counter count;
    memset(&count, 0, sizeof count);
    gsf_context ctx;
    test_context_zero(&ctx);
    ctx.threads = 1;
    count_memory(&ctx, &count);
    if (gsf_init_context(&ctx) != GSF_OK) exit(2);
    const gsf_nn_dit_desc desc = small_desc(features, 1);
    for (size_t k = 1;; k += k < 10 ? 1 : k / 3) {
        gsf_restorer r;
        count.calls = 0;
        count.fail_at = k;
        gsf_result result = gsf_nn_make_dit(&ctx, &desc, &r);
        if (!result) result = r.restore_fn(r.user, &ctx, &c->window);
        gsf_nn_destroy_dit(&ctx, &r);
        CHECK(count.live == 0);
        if (!result) { CHECK(count.calls < k); break; }
        CHECK(result == GSF_ERROR_OUT_OF_MEMORY);
    }
}

int main(void) {
    gsf_context ctx;
    clip c;
    sample_case s;
    test_context_init(&ctx);
    char features[1100];
    snprintf(features, sizeof features, "%s", write_features(&ctx, "features.safetensors", NULL));
    open_sample(&ctx, &s);
    make_clip(&ctx, &c, 9, s.desc.width, s.desc.height);
    test_limits(&ctx, features, &c);
    test_references(&ctx, features, &c);
    test_cropped_reference(&ctx, features, &c);
    test_prompts(&ctx, features, &c);
    test_conditions(&ctx, features, &c);
    test_workers(features, &c);
    test_memory(features, &c);
    test_skips(&ctx, &s);
    test_bad_sample(&ctx, &s);
    test_bad_weight(&ctx, &s);
    test_resume(&ctx, &s);
    close_sample(&ctx, &s);
    free_clip(&ctx, &c);
    return test_report();
}
