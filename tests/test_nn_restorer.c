// The restorer `dit` through the restorer interface of gsfixer.h, on the small golden model: accepted inputs, skipped
// work, workers, cancelling and resuming, invalid weights and features.
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

// Writes the features of the golden pipeline to one file, as --ref-features takes it; `without` names a tensor to leave
// out.
static const char* write_features(gsf_context* ctx, const char* name, const char* without) {
    const char* path = test_scratch(name);
    gsf_nn_weights inputs, expected;
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_golden("restorer/pipeline/inputs.safetensors"), NULL, &inputs));
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, test_golden("restorer/pipeline/expected.safetensors"), NULL, &expected));
    const gsf_nn_tensor* const all[] = {gsf_nn_find_tensor(&inputs, "dino_latents"),
                                     gsf_nn_find_tensor(&inputs, "vggt_latents"),
                                     gsf_nn_find_tensor(&expected, "prompt_embeds")};
    gsf_nn_tensor tensors[3];
    size_t count = 0;
    for (int i = 0; i < 3; i++)
        if (CHECK(all[i] != NULL) && !(without && strcmp(all[i]->name, without) == 0)) tensors[count++] = *all[i];
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, count));
    gsf_nn_destroy_weights(ctx, &inputs);
    gsf_nn_destroy_weights(ctx, &expected);
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
        for (int32_t i = 0; i < 3 * width * height; i++) v[i] = (float)(floor(255.999 * test_random(&state)) / 255.0);
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

// Runs one clip through a restorer made from this desc; returns the checksum of the result, or 0 if it failed.
static uint32_t restore(gsf_context* ctx, const gsf_nn_dit_desc* desc, clip* c, gsf_result wanted) {
    gsf_restorer r;
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, desc, &r))) return 0;
    CHECK_OK(ctx, r.begin_fn(r.user, ctx, NULL, 0));
    const int ok = CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), wanted) && wanted == GSF_OK;
    r.end_fn(r.user, ctx);
    gsf_destroy_restorer(ctx, &r);
    return ok ? checksum(c) : 0;
}

static void test_limits(gsf_context* ctx, const char* features, clip* c) {
    const gsf_nn_dit_desc desc = small_desc(features, 2);
    gsf_restorer r;
    gsf_restorer_info limits;
    memset(&limits, 0, sizeof limits);
    limits.struct_size = sizeof limits;
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) return;
    CHECK(r.struct_size == sizeof r && strcmp(r.name, "dit") == 0);
    CHECK_OK(ctx, r.query_fn(r.user, ctx, c->frames, c->width, c->height, &limits));
    // the count that it was trained with
    CHECK(limits.frame_count_min == 9 && limits.frame_count_max == 9 && limits.frame_count == 9);
    CHECK(limits.squash && limits.width == c->width && limits.height == c->height);
    // learned position embeddings allow one size only
    CHECK(limits.width_multiple == c->width && limits.height_multiple == c->height);
    CHECK(limits.bytes > 0.0 && limits.flops > 0.0 && !limits.needs_depth && !limits.needs_alpha);
    limits.bytes = 0.0;
    // an unsupported size: no cost is reported, but the limits are
    CHECK_OK(ctx, r.query_fn(r.user, ctx, 10, c->width + 1, c->height, &limits));
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
    gsf_destroy_restorer(ctx, &r);
    gsf_destroy_restorer(ctx, &r); // destroying twice is allowed
}

// A frame at the view of a reference is replaced by the photo.
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
    gsf_destroy_restorer(ctx, &r);
}

// Compares the restored clip whose first frame is the view of `photo` as `camera` sees it (NULL: the whole photo) with
// that of a clip whose first frame is `seen`.
static void check_photo_frame(gsf_context* ctx, gsf_restorer* r, clip* c, const gsf_reference* photo,
                              const gsf_camera* camera, const gsf_image* seen) {
    gsf_camera cameras[MAX_FRAMES];
    const gsf_image frame = c->color[0];
    for (int32_t i = 0; i < c->frames && camera; i++) cameras[i] = *camera;
    c->window.cameras = camera ? cameras : NULL;
    c->reference_index[0] = 0;
    gsf_reference lent = *photo;
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, photo->color.width, photo->color.height, 3, &lent.color));
    CHECK_OK(ctx, gsf_convert_image(ctx, &photo->color, &lent.color));
    CHECK_OK(ctx, r->begin_fn(r->user, ctx, &lent, 1));
    gsf_destroy_image(ctx, &lent.color); // only borrowed
    CHECK_OK(ctx, r->restore_fn(r->user, ctx, &c->window));
    r->end_fn(r->user, ctx);
    const uint32_t with_photo = checksum(c);
    c->window.cameras = NULL;
    c->reference_index[0] = -1;
    c->color[0] = *seen;
    CHECK_OK(ctx, r->restore_fn(r->user, ctx, &c->window));
    CHECK(checksum(c) == with_photo);
    c->color[0] = frame;
}

// A photo of another size and aspect ratio becomes a frame as PIL resizes it: either the whole photo, squashed, or the
// part that a camera sees, which lacks 8 columns on one side and extends 8 columns beyond the other.
static void test_photo_frames(gsf_context* ctx, const char* features, clip* c) {
    const gsf_nn_dit_desc desc = small_desc(features, 1);
    gsf_restorer r;
    gsf_reference photo;
    gsf_image bytes, seen;
    const int32_t width = 2 * c->width, height = 3 * c->height;
    memset(&photo, 0, sizeof photo);
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, width, height, 3, &photo.color));
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, c->width, c->height, 3, &bytes));
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, c->width, c->height, 3, &seen));
    for (int64_t i = 0; i < 3 * (int64_t)width * height; i++)
        ((uint8_t*)photo.color.data)[i] = (uint8_t)(i * 2654435761u >> 24);
    CHECK_OK(ctx, gsf_resize_image(ctx, &photo.color, GSF_RESIZE_PIL_BICUBIC, &bytes));
    CHECK_OK(ctx, gsf_convert_image(ctx, &bytes, &seen));
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) return;
    check_photo_frame(ctx, &r, c, &photo, NULL, &seen);
    memset(&photo.camera, 0, sizeof photo.camera);
    for (int k = 0; k < 4; k++) photo.camera.w2c[5 * k] = 1.0;
    photo.camera.width = width;
    photo.camera.height = height;
    photo.camera.fx = photo.camera.fy = 200.0;
    photo.camera.cx = 0.5 * width;
    photo.camera.cy = 0.5 * height;
    gsf_camera camera = gsf_resize_camera(&photo.camera, c->width, c->height);
    check_photo_frame(ctx, &r, c, &photo, &camera, &seen);
    camera.cx -= 8.0;
    float* v = (float*)seen.data;
    for (int64_t y = 0; y < c->height; y++) {
        float* row = v + 3 * y * c->width;
        const size_t kept = 3 * (size_t)(c->width - 8);
        memmove(row, row + 24, kept * sizeof(float));
        memcpy(row + kept, (const float*)c->color[0].data + 3 * y * c->width + (int64_t)kept, 24 * sizeof(float));
    }
    check_photo_frame(ctx, &r, c, &photo, &camera, &seen);
    gsf_destroy_image(ctx, &photo.color);
    gsf_destroy_image(ctx, &bytes);
    gsf_destroy_image(ctx, &seen);
    gsf_destroy_restorer(ctx, &r);
}

// Every condition gives a different result; disabling the cache of the references' keys changes no bit.
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
    desc.condition = GSF_NN_CONDITION_2D;
    // features that the condition does not use may be missing
    CHECK(restore(ctx, &desc, c, GSF_OK) == sums[GSF_NN_CONDITION_2D]);
    gsf_restorer r;
    desc.condition = GSF_NN_CONDITION_BOTH;
    // the folder has no encoder to compute them
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "/vggt/") != NULL && strstr(ctx->error, "vggt_latents") != NULL && r.user == NULL);
}

// Prompts computed with the folder's tokenizer and text encoder; once saved, they are used without either.
static void test_prompts(gsf_context* ctx, const char* features, clip* c) {
    char saved[1100];
    gsf_nn_dit_desc desc = small_desc(write_features(ctx, "no_text.safetensors", "prompt_embeds"), 2);
    gsf_restorer r;
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_NOT_FOUND); // neither a caption nor a captioner
    CHECK(strstr(ctx->error, "/blip2/") != NULL && strstr(ctx->error, "a caption") != NULL && r.user == NULL);
    snprintf(saved, sizeof saved, "%s", test_scratch("saved.safetensors"));
    desc.caption = "a wall";
    desc.save_features = saved;
    const uint32_t wall = restore(ctx, &desc, c, GSF_OK);
    const gsf_nn_dit_desc again = small_desc(saved, 2);
    CHECK(restore(ctx, &again, c, GSF_OK) == wall);
    desc.caption = "a view of trees";
    CHECK(restore(ctx, &desc, c, GSF_OK) != wall);
    desc.features = features; // prompts in the file take precedence over a caption
    const gsf_nn_dit_desc plain = small_desc(features, 2);
    CHECK(restore(ctx, &desc, c, GSF_OK) == restore(ctx, &plain, c, GSF_OK));
    desc.features = NULL;
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "/dinov2/") != NULL && strstr(ctx->error, "dino_latents") != NULL);
    desc.condition = GSF_NN_CONDITION_NONE;
    CHECK(restore(ctx, &desc, c, GSF_OK) != 0);
    desc.model = test_golden("restorer/model/transformer"); // the error names the first missing part
    CHECK_RESULT(ctx, gsf_nn_make_dit(ctx, &desc, &r), GSF_ERROR_NOT_FOUND);
}

// ---- features of several photos and clips

enum { PHOTOS = 6, CLIPS = 3, PHOTO_TOKENS = 5 };

// Cameras of six photos on a circle around the centre, except for the last, which is at the position of the first and
// looks away. All are scaled, rotated about z and translated together.
static void place_photos(gsf_camera* cameras, double scale, double turn, double shift) {
    for (int i = 0; i < PHOTOS; i++) {
        const double a = i == PHOTOS - 1 ? 0.0 : 0.4 * i, view = i == PHOTOS - 1 ? 2.2 : a; // looks along +z at a = 0
        const double c2w[16] = {cos(view), 0, -sin(view), 0, 0, 1, 0, 0, sin(view), 0, cos(view), 0,
                                -3.0 * sin(a), 0.1 * i, -3.0 * cos(a), 1};
        const double c = cos(turn), s = sin(turn);
        double moved[16];
        for (int k = 0; k < 4; k++) {
            const double x = c2w[4 * k], y = c2w[4 * k + 1], size = k == 3 ? scale : 1.0;
            moved[4 * k] = size * (c * x - s * y) + (k == 3 ? shift : 0.0);
            moved[4 * k + 1] = size * (s * x + c * y) - (k == 3 ? 2.0 * shift : 0.0);
            moved[4 * k + 2] = size * c2w[4 * k + 2];
            moved[4 * k + 3] = c2w[4 * k + 3];
        }
        memset(&cameras[i], 0, sizeof cameras[i]);
        gsf_set_camera_c2w(&cameras[i], moved);
        cameras[i].fx = cameras[i].fy = 20.0;
        cameras[i].cx = cameras[i].cy = 8.0;
        cameras[i].width = cameras[i].height = 16;
    }
}

static void lend_photos(gsf_context* ctx, gsf_restorer* r, const gsf_camera* cameras) {
    static uint8_t pixels[PHOTOS][3 * 16 * 16];
    gsf_reference photos[PHOTOS];
    memset(photos, 0, sizeof photos);
    for (int i = 0; i < PHOTOS; i++) {
        memset(pixels[i], 30 * i, sizeof pixels[i]);
        photos[i].color = gsf_wrap_image(pixels[i], GSF_U8, 16, 16, 3);
        photos[i].camera = cameras[i];
    }
    CHECK_OK(ctx, r->begin_fn(r->user, ctx, photos, PHOTOS));
    CHECK_RESULT(ctx, r->begin_fn(r->user, ctx, photos, 1), GSF_ERROR_INVALID_ARGUMENT); // not the photos of this run
}

static void save_random(gsf_context* ctx, const char* path, char (*names)[40], const int64_t (*shapes)[3], size_t count,
                        uint64_t seed) {
    gsf_nn_tensor tensors[16];
    memset(tensors, 0, sizeof tensors);
    for (size_t i = 0; i < count; i++) {
        const int64_t values = shapes[i][0] * shapes[i][1] * shapes[i][2];
        float* v = (float*)malloc((size_t)values * sizeof(float));
        uint64_t state = seed + i;
        for (int64_t k = 0; k < values; k++) v[k] = (float)test_random_in(&state, -1.0, 1.0);
        tensors[i] = gsf_nn_wrap_tensor(names[i], v, 3, shapes[i]);
    }
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, count));
    for (size_t i = 0; i < count; i++) free((void*)tensors[i].data);
}

// The photo that a clip between two cameras looks up first, found from the missing tensor that the error names when the
// file has the tokens of only one photo; -1: none.
static int missing_photo(gsf_context* ctx, gsf_restorer* r, clip* c, const gsf_camera* from, const gsf_camera* to) {
    gsf_camera cameras[MAX_FRAMES];
    int photo = -1;
    for (int32_t i = 0; i < c->frames; i++) cameras[i] = i < c->frames / 2 ? *from : *to;
    c->window.cameras = cameras;
    c->window.clip = 1;
    CHECK_RESULT(ctx, r->restore_fn(r->user, ctx, &c->window), GSF_ERROR_NOT_FOUND);
    const char* at = strstr(ctx->error, "dino_latents.photo");
    if (CHECK(at != NULL)) photo = atoi(at + strlen("dino_latents.photo"));
    c->window.clip = 0;
    c->window.cameras = NULL;
    return photo;
}

// The choice of the nearest photos does not depend on scale, rotation or translation of the scene.
static void test_nearest(gsf_context* ctx, clip* c, const gsf_nn_transformer* net) {
    char names[2][40] = {"dino_latents.photo63", "prompt_embeds.clip1"};
    const int64_t shapes[2][3] = {{1, PHOTO_TOKENS, net->dino_channels}, {2, net->text_tokens, net->text_channels}};
    const struct { double scale, turn, shift; } worlds[] = {{1, 0, 0}, {0.01, 0, 0}, {100, 0, 0}, {1, 0.7, 0}, {1, 2.5, 40},
                                                            {100, -1.1, 300}, {0.01, 1.9, -0.2}};
    int wanted[32], seen[PHOTOS] = {0};
    gsf_restorer r;
    char path[1100];
    snprintf(path, sizeof path, "%s", test_scratch("one_photo.safetensors"));
    save_random(ctx, path, names, shapes, 2, 9);
    gsf_nn_dit_desc desc = small_desc(path, 1);
    desc.condition = GSF_NN_CONDITION_2D;
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) return;
    for (size_t w = 0; w < sizeof worlds / sizeof *worlds; w++) {
        gsf_camera photos[PHOTOS];
        place_photos(photos, worlds[w].scale, worlds[w].turn, worlds[w].shift);
        lend_photos(ctx, &r, photos);
        uint64_t state = 3;
        // the position of one photo, moved towards another's, with the direction of a third
        for (int k = 0; k < 32; k++) {
            const gsf_camera* a = &photos[(size_t)(test_random(&state) * PHOTOS)];
            const gsf_camera* b = &photos[(size_t)(test_random(&state) * PHOTOS)];
            gsf_camera camera = photos[(size_t)(test_random(&state) * PHOTOS)];
            const double t = 0.6 * test_random(&state);
            double c2w[16], first[3], second[3];
            gsf_get_camera_c2w(&camera, c2w);
            gsf_get_camera_center(a, first);
            gsf_get_camera_center(b, second);
            for (int i = 0; i < 3; i++) c2w[12 + i] = first[i] + t * (second[i] - first[i]);
            gsf_set_camera_c2w(&camera, c2w);
            const int chosen = missing_photo(ctx, &r, c, &camera, &camera);
            if (w == 0) seen[wanted[k] = chosen]++;
            CHECK(chosen == wanted[k]);
        }
        r.end_fn(r.user, ctx);
    }
    for (int i = 0; i < PHOTOS; i++) CHECK(seen[i] > 0);
    gsf_destroy_restorer(ctx, &r);
}

// Checksums of three clips, each between different photos, from a restorer made from this desc; zero where an error is
// expected.
static void restore_clips(gsf_context* ctx, const gsf_nn_dit_desc* desc, clip* c, uint32_t sums[CLIPS]) {
    gsf_restorer r;
    gsf_camera photos[PHOTOS], cameras[MAX_FRAMES];
    if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, desc, &r))) return;
    place_photos(photos, 1.0, 0.0, 0.0);
    lend_photos(ctx, &r, photos);
    c->window.cameras = cameras;
    for (int k = 0; k < CLIPS; k++) {
        for (int32_t i = 0; i < c->frames; i++) cameras[i] = photos[i < c->frames / 2 ? k : k + 1];
        c->window.clip = k;
        CHECK_OK(ctx, r.restore_fn(r.user, ctx, &c->window));
        sums[k] = checksum(c);
    }
    c->window.clip = CLIPS; // a clip that is not in the file
    CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "prompt_embeds.clip3") != NULL);
    c->window.clip = 1; // nor does it have this combination of photos
    cameras[0] = photos[4];
    CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "dino_latents.photo4") != NULL);
    cameras[0] = photos[0];
    CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx->error, "vggt_latents.photo0,3") != NULL);
    r.end_fn(r.user, ctx);
    gsf_destroy_restorer(ctx, &r);
    c->window.cameras = NULL;
    c->window.clip = 0;
}

// Writes the features of clip k from the file for all clips, under names without suffixes.
static void write_bare(gsf_context* ctx, const char* all, const char* path, int k, const gsf_nn_transformer* net) {
    gsf_nn_weights file;
    char name[40];
    gsf_nn_tensor tensors[3];
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, all, NULL, &file));
    const int64_t each = (int64_t)PHOTO_TOKENS * net->dino_channels, shape[3] = {2, PHOTO_TOKENS, net->dino_channels};
    float* dino = (float*)malloc(2 * (size_t)each * sizeof(float));
    for (int i = 0; i < 2; i++) {
        snprintf(name, sizeof name, "dino_latents.photo%d", k + i);
        gsf_nn_convert_tensor(gsf_nn_find_tensor(&file, name), 0, each, dino + i * each);
    }
    tensors[0] = gsf_nn_wrap_tensor("dino_latents", dino, 3, shape);
    snprintf(name, sizeof name, "vggt_latents.photo%d,%d", k, k + 1);
    tensors[1] = *gsf_nn_find_tensor(&file, name);
    tensors[1].name = "vggt_latents";
    snprintf(name, sizeof name, "prompt_embeds.clip%d", k);
    tensors[2] = *gsf_nn_find_tensor(&file, name);
    tensors[2].name = "prompt_embeds";
    CHECK_OK(ctx, gsf_nn_save_tensors(ctx, path, tensors, 3));
    gsf_nn_destroy_weights(ctx, &file);
    free(dino);
}

// Three clips, each between different photos and with its own prompts: from one file, from the features saved in that
// run, and from a separate file for each clip.
static void test_clips(gsf_context* ctx, clip* c, const gsf_nn_transformer* net) {
    char names[10][40], path[1100], saved[1100], bare[1100];
    int64_t shapes[10][3];
    size_t count = 0;
    for (int i = 0; i < 10; i++) {
        const int k = i < 4 ? i : (i - 4) % 3;
        const char* format = i < 4 ? "dino_latents.photo%d" : i < 7 ? "vggt_latents.photo%d,%d" : "prompt_embeds.clip%d";
        snprintf(names[count], sizeof names[0], format, k, k + 1);
        shapes[count][0] = i < 4 ? 1 : 2;
        shapes[count][1] = i < 7 ? PHOTO_TOKENS : net->text_tokens;
        shapes[count++][2] = i < 4 ? net->dino_channels : i < 7 ? net->vggt_channels : net->text_channels;
    }
    snprintf(path, sizeof path, "%s", test_scratch("clips.safetensors"));
    snprintf(saved, sizeof saved, "%s", test_scratch("clips_saved.safetensors"));
    snprintf(bare, sizeof bare, "%s", test_scratch("clips_bare.safetensors"));
    save_random(ctx, path, names, (const int64_t(*)[3])shapes, count, 21);
    gsf_nn_dit_desc desc = small_desc(path, 1);
    uint32_t sums[CLIPS] = {0}, again[CLIPS] = {0};
    desc.save_features = saved;
    restore_clips(ctx, &desc, c, sums);
    CHECK(sums[0] != sums[1] && sums[1] != sums[2] && sums[0] != sums[2]);
    desc.features = saved;
    desc.save_features = NULL;
    restore_clips(ctx, &desc, c, again);
    CHECK(memcmp(sums, again, sizeof sums) == 0);
    for (int k = 0; k < CLIPS; k++) {
        gsf_restorer r;
        write_bare(ctx, path, bare, k, net);
        desc.features = bare;
        CHECK(restore(ctx, &desc, c, GSF_OK) == sums[k]);
        if (!CHECK_OK(ctx, gsf_nn_make_dit(ctx, &desc, &r))) continue;
        c->window.clip = 1; // a name without suffix is not used for another clip
        CHECK_RESULT(ctx, r.restore_fn(r.user, ctx, &c->window), GSF_ERROR_NOT_FOUND);
        CHECK(strstr(ctx->error, "prompt_embeds.clip1") != NULL);
        c->window.clip = 0;
        gsf_destroy_restorer(ctx, &r);
    }
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
    CHECK_OK(ctx, gsf_nn_load_transformer(ctx, path, &s->net));
    snprintf(path, sizeof path, "%s/vae", model_folder());
    CHECK_OK(ctx, gsf_nn_load_vae(ctx, path, &s->vae));
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

static void test_skips(gsf_context* ctx, sample_case* s) {
    float* reference = (float*)malloc(s->values * sizeof(float));
    s->desc.steps = 8;
    gsf_nn_sample_stats stats = run_sample(ctx, s, reference);
    CHECK(stats.steps == 8 && stats.network_rows == 16 && stats.cached_steps == 0);

    s->desc.guidance_begin = 0.25f; // half of the steps guided
    s->desc.guidance_end = 0.75f;
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.network_rows == 12 && test_relative_error(s->video, reference, s->values) > 1e-4);
    s->desc.guidance_begin = s->desc.guidance_end = 0.0f;

    s->desc.block_cache = 1e-9f; // so small that no two steps are similar enough: the same bits as without the cache
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.cached_steps == 0 && memcmp(s->video, reference, s->values * sizeof(float)) == 0);
    s->desc.block_cache = 0.8f; // with random weights, successive steps differ a lot
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.cached_steps > 0 && stats.cached_steps < 8);
    CHECK(test_relative_error(s->video, reference, s->values) < 1.0);
    s->desc.block_cache = 0.0f;

    s->desc.strength = 0.5f; // the last half of the schedule, from the noised control frames
    stats = run_sample(ctx, s, s->video);
    CHECK(stats.steps == 4 && stats.network_rows == 8);
    s->desc.strength = 0.0f;

    // solvers nearly agree at many steps
    for (int solver = GSF_NN_SOLVER_DDIM; solver <= GSF_NN_SOLVER_UNIPC; solver++) {
        s->desc.solver = (gsf_nn_solver)solver;
        s->desc.steps = 40;
        run_sample(ctx, s, solver ? s->video : reference);
        if (solver) CHECK(test_relative_error(s->video, reference, s->values) < 0.2);
    }
    s->desc.solver = GSF_NN_SOLVER_DDIM;
    s->desc.steps = 0;
    free(reference);
}

static void test_bad_sample(gsf_context* ctx, sample_case* s) {
    const gsf_nn_sample_desc good = s->desc;
    gsf_nn_sample_info cost;
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
    CHECK_OK(ctx, gsf_nn_query_sample(ctx, &s->net, &s->vae, &s->desc, &cost));
    CHECK(cost.bytes > 1e5 && cost.flops > 1e9);
}

// The error names the weight that contains a NaN, or the block in which it appears.
static void test_bad_weight(gsf_context* ctx, sample_case* s) {
    const char* name = "transformer_blocks.1.ff.net.2.weight";
    gsf_nn_tensor* tensor = NULL;
    for (size_t i = 0; i < s->net.weights.tensor_count; i++)
        if (strcmp(s->net.weights.tensors[i].name, name) == 0) tensor = &s->net.weights.tensors[i];
    if (!CHECK(tensor != NULL)) return;
    const size_t bytes = (size_t)tensor->count * gsf_nn_get_dtype_size(tensor->dtype);
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
    for (int solver = GSF_NN_SOLVER_DDIM; solver <= GSF_NN_SOLVER_UNIPC; solver++) {
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
        stats = run_sample(ctx, s, s->video); // only decoding is left
        CHECK(stats.steps == 0 && memcmp(s->video, reference, s->values * sizeof(float)) == 0);
        s->desc.seed++; // another seed: the checkpoint does not match
        stats = run_sample(ctx, s, s->video);
        CHECK(stats.resumed_from == 0 && stats.steps == 6);
        s->desc.seed--;
        CHECK_OK(ctx, gsf_write_file(ctx, path, "GSFCHUNKgarbage", 15)); // nor is a damaged checkpoint used
        stats = run_sample(ctx, s, s->video);
        CHECK(stats.resumed_from == 0 && memcmp(s->video, reference, s->values * sizeof(float)) == 0);
    }
    s->desc.checkpoint = NULL;
    s->desc.solver = GSF_NN_SOLVER_DDIM;
    s->desc.steps = 0;
    free(reference);
}

static char last_warning[600];
static void hear(void* user, gsf_log_level level, const char* text) {
    (void)user;
    if (level == GSF_LOG_WARNING) snprintf(last_warning, sizeof last_warning, "%s", text);
}

// A checkpoint of another precision, schedule or weights is ignored, and the log says so.
static void test_other_models(gsf_context* ctx, sample_case* s) {
    const char* path = test_scratch("models.checkpoint");
    sample_case other;
    const gsf_logger logger = ctx->logger;
    ctx->logger.log_fn = hear;
    ctx->logger.user = NULL;
    for (int kind = 0; kind < 6; kind++) {
        open_sample(ctx, &other);
        other.desc.steps = s->desc.steps = 2;
        other.desc.checkpoint = s->desc.checkpoint = path;
        remove(path);
        run_sample(ctx, s, s->video);
        gsf_nn_sample_stats stats = run_sample(ctx, &other, other.video);
        CHECK(stats.resumed_from == 2 && stats.steps == 0);
        gsf_nn_weights* weights = kind == 2 ? &other.vae.weights : &other.net.weights;
        gsf_nn_tensor* tensor = &weights->tensors[weights->tensor_count / 2];
        const size_t bytes = (size_t)tensor->count * gsf_nn_get_dtype_size(tensor->dtype);
        char* copy = (char*)malloc(bytes);
        memcpy(copy, tensor->data, bytes);
        copy[bytes - 2] ^= 1;
        if (kind == 0) other.net.bf16 = 1;
        if (kind == 1 || kind == 2) tensor->data = copy;
        if (kind == 3) other.schedule.alpha_bar[500] *= 1.001;
        if (kind == 4) other.desc.guidance = 3.0f;
        if (kind == 5) CHECK_OK(ctx, gsf_nn_quantize_transformer(ctx, &other.net, NULL));
        last_warning[0] = 0;
        stats = run_sample(ctx, &other, other.video);
        CHECK(stats.resumed_from == 0 && stats.steps == 2);
        if (!CHECK(strstr(last_warning, "the clip is restarted") != NULL))
            fprintf(stderr, "  case %d: %s\n", kind, last_warning);
        close_sample(ctx, &other);
        free(copy);
    }
    ctx->logger = logger;
    s->desc.checkpoint = NULL;
    s->desc.steps = 0;
}

// Frame counts other than the trained one must be enabled with any_frames.
static void test_any_frames(gsf_context* ctx, sample_case* s) {
    s->desc.frames = 1;
    s->desc.steps = 1;
    CHECK_RESULT(ctx, gsf_nn_sample(ctx, &s->net, &s->vae, &s->schedule, &s->desc, s->video, NULL), GSF_ERROR_UNSUPPORTED);
    CHECK(strstr(ctx->error, "any_frames") != NULL);
    s->desc.any_frames = 1;
    CHECK(run_sample(ctx, s, s->video).steps == 1);
    s->desc.frames = 9; // the same clip, then as if 9 were not the trained count
    s->desc.guidance = 1.0f;
    run_sample(ctx, s, s->video);
    float* sines = (float*)malloc(s->values * sizeof(float));
    s->net.sample_frames = 17;
    run_sample(ctx, s, sines);
    s->net.sample_frames = 9;
    const double apart = test_relative_error(sines, s->video, s->values);
    printf("sines in place of the learned positions: relative L2 %.3g of the frames\n", apart);
    CHECK(apart > 1e-3);
    free(sines);
    s->desc.guidance = 0.0f;
    s->desc.any_frames = 0;
    s->desc.frames = 9;
    s->desc.steps = 0;
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

// each of the first ten allocations fails, then some later ones
static void test_memory(const char* features, clip* c) {
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
        gsf_destroy_restorer(&ctx, &r);
        CHECK(count.live == 0);
        if (!result) { CHECK(count.calls < k); break; }
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
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
    test_photo_frames(&ctx, features, &c);
    test_prompts(&ctx, features, &c);
    test_conditions(&ctx, features, &c);
    test_workers(features, &c);
    test_memory(features, &c);
    test_skips(&ctx, &s);
    test_bad_sample(&ctx, &s);
    test_bad_weight(&ctx, &s);
    test_resume(&ctx, &s);
    test_other_models(&ctx, &s);
    test_any_frames(&ctx, &s);
    test_nearest(&ctx, &c, &s.net);
    test_clips(&ctx, &c, &s.net);
    close_sample(&ctx, &s);
    free_clip(&ctx, &c);
    return test_report();
}
