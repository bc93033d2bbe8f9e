// in_memory.c - cc -O2 -std=c11 -fopenmp -DGSFIXER_IMPLEMENTATION -I. examples/in_memory.c -o in_memory -lm
// For hosts with an asset system of their own: the library opens no file. The model and the photos are given as bytes, a
// frame that the host has repaired by itself is trained on alongside the photos, and the splats come back as bytes.
//     in_memory SCENE OUT.ply      SCENE: images/ with sparse/0/*.bin, or a transforms.json
#include "gsfixer_splat.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { STEPS = 60, REPAIRED_STEPS = 40 };

typedef struct host {
    gsf_context ctx;
    gsf_scene scene;
    gsf_train_view* views; // their images are the scene's
    gsf_splats splats;
    gsf_trainer* trainer;
} host;

// Stands in for the host's archive. data NULL: there is no such file. Freed with free.
static gsf_bytes fetch(const char* folder, const char* name) {
    gsf_bytes bytes = {NULL, 0, name};
    char path[1024];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE* file = fopen(path, "rb");
    if (!file) return bytes;
    if (fseek(file, 0, SEEK_END) == 0 && ftell(file) > 0) {
        const size_t size = (size_t)ftell(file);
        char* data = (char*)malloc(size);
        rewind(file);
        if (data && fread(data, 1, size, file) == size) bytes.size = size;
        bytes.data = data;
    }
    fclose(file);
    return bytes;
}

static gsf_result parse_model(host* h, const char* folder) {
    const gsf_bytes cameras = fetch(folder, "sparse/0/cameras.bin"), images = fetch(folder, "sparse/0/images.bin");
    const gsf_bytes points = fetch(folder, "sparse/0/points3D.bin"), json = fetch(folder, "transforms.json");
    gsf_result result = GSF_ERROR_NOT_FOUND;
    if (cameras.data && images.data)
        result = gsf_splat_parse_colmap(&h->ctx, 0, &cameras, &images, points.data ? &points : NULL, &h->scene);
    else if (json.data)
        result = gsf_splat_parse_transforms(&h->ctx, &json, &h->scene);
    else
        gsf_fail(&h->ctx, result, "%s: neither sparse/0 nor transforms.json", folder);
    free((void*)cameras.data);
    free((void*)images.data);
    free((void*)points.data);
    free((void*)json.data);
    return result;
}

// Decodes a photo and gives it to the scene, which undistorts it. A host's own decoder would do as well.
static gsf_result set_photo(host* h, const char* folder, size_t view) {
    char name[512];
    gsf_image photo = {0};
    const char* file = h->scene.views[view].name;
    snprintf(name, sizeof name, strchr(file, '/') ? "%s" : "images/%s", file);
    const gsf_bytes bytes = fetch(folder, name);
    gsf_result result = bytes.data ? GSF_OK : gsf_fail(&h->ctx, GSF_ERROR_NOT_FOUND, "%s: no such photo", name);
    if (result == GSF_OK) result = gsf_decode_image(&h->ctx, name, bytes.data, bytes.size, 3, &photo);
    if (result == GSF_OK) result = gsf_splat_set_view_image(&h->ctx, &h->scene, view, &photo);
    gsf_destroy_image(&h->ctx, &photo);
    free((void*)bytes.data);
    return result;
}

static gsf_result train(host* h, int steps) {
    gsf_result result = GSF_OK;
    gsf_train_stats stats = {0};
    for (int i = 0; i < steps && result == GSF_OK; i++) result = gsf_splat_step_trainer(&h->ctx, h->trainer, &stats);
    if (result == GSF_OK)
        printf("iteration %d: %zu splats, loss %.4f\n", (int)stats.iteration, stats.splats, stats.loss);
    return result;
}

// The view halfway between the first two photos: rendered, repaired by the host, and trained on with half of a photo's weight.
static gsf_result repair(host* h) {
    gsf_context* ctx = &h->ctx;
    gsf_train_view between = {0};
    gsf_render_output out = {0};
    double c2w[16], other[16];
    between.camera = h->views[0].camera;
    gsf_get_camera_c2w(&h->views[0].camera, c2w);
    gsf_get_camera_c2w(&h->views[h->scene.view_count > 1].camera, other);
    for (int k = 12; k < 15; k++) c2w[k] = 0.5 * (c2w[k] + other[k]);
    gsf_set_camera_c2w(&between.camera, c2w);
    gsf_result result = gsf_make_image(ctx, GSF_F32, between.camera.width, between.camera.height, 3, &between.image);
    out.color = between.image;
    if (result == GSF_OK) result = gsf_splat_render_trainer(ctx, h->trainer, &between.camera, &out);
    // here a host would repair between.image; this program leaves it unchanged
    if (result == GSF_OK) result = gsf_splat_set_restored_views(ctx, h->trainer, &between, 1);
    gsf_splat_set_restored_weight(h->trainer, 0.5f);
    gsf_destroy_image(ctx, &between.image);
    return result;
}

static gsf_result run(host* h, const char* folder) {
    gsf_context* ctx = &h->ctx;
    gsf_splats start = {0};
    gsf_initial_desc initial = {0};
    gsf_train_desc desc = {0};
    gsf_result result = parse_model(h, folder);
    const size_t count = h->scene.view_count;
    for (size_t i = 0; i < count && result == GSF_OK; i++) result = set_photo(h, folder, i);
    if (result == GSF_OK) result = gsf_splat_load_train_views(ctx, &h->scene, NULL, count, &h->views); // all are there
    initial.kind = h->scene.point_count ? GSF_INITIAL_ALL : GSF_INITIAL_RANDOM;
    if (result == GSF_OK) result = gsf_splat_make_initial_splats(ctx, &h->scene, NULL, count, &initial, &start, NULL);
    if (result == GSF_OK) result = gsf_splat_sort(ctx, &start); // neighbours in space become neighbours in memory
    desc.iterations = STEPS + REPAIRED_STEPS;
    if (result == GSF_OK) result = gsf_splat_make_trainer(ctx, &desc, h->views, count, &start, &h->trainer);
    gsf_splat_destroy(ctx, &start);
    if (result == GSF_OK) result = train(h, STEPS);
    if (result == GSF_OK) result = repair(h);
    if (result == GSF_OK) result = train(h, REPAIRED_STEPS);
    if (result == GSF_OK) result = gsf_splat_copy_trained(ctx, h->trainer, &h->splats);
    gsf_splat_destroy_trainer(ctx, h->trainer); // the splats are a copy
    return result;
}

int main(int argc, char** argv) {
    if (argc != 3) return fprintf(stderr, "usage: %s SCENE OUT.ply\n", argv[0]), 2;
    host h = {0};
    gsf_buffer out = {0};
    gsf_result result = gsf_init_context(&h.ctx);
    if (result == GSF_OK) result = run(&h, argv[1]);
    if (result == GSF_OK) result = gsf_splat_format(&h.ctx, argv[2], &h.splats, NULL, &out);
    FILE* file = result == GSF_OK ? fopen(argv[2], "wb") : NULL; // the host's again
    if (result == GSF_OK && (!file || fwrite(out.data, 1, out.size, file) != out.size))
        result = gsf_fail(&h.ctx, GSF_ERROR_IO, "%s: cannot be written", argv[2]);
    if (file && fclose(file) != 0) result = gsf_fail(&h.ctx, GSF_ERROR_IO, "%s: cannot be written", argv[2]);
    if (result != GSF_OK) fprintf(stderr, "%s\n", h.ctx.error);
    gsf_destroy_buffer(&h.ctx, &out);
    gsf_splat_destroy(&h.ctx, &h.splats);
    gsf_free(&h.ctx, h.views);
    gsf_splat_destroy_scene(&h.ctx, &h.scene);
    return result == GSF_OK ? 0 : 1;
}
