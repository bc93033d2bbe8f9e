// Cameras written as transforms.json and as COLMAP's text are read back by the scene loaders; EXR and 16-bit PNG files of an
// implementation without OpenImageIO have the documented bytes (test_oiio.cpp reads them with OpenImageIO).
#include "gsfixer_splat.h"
#include "test.h"

enum { CAMERAS = 40 };

static void random_camera(uint64_t i, gsf_camera* out) { // any rotation, now and then one by half a turn
    double q[4], norm = 0.0, c2w[16] = {0};
    for (int k = 0; k < 4; k++) q[k] = i % 8 == 7 ? (double)((int)(i / 8) % 4 == k) : gsf_draw_normal(1, (uint64_t)k, i);
    for (int k = 0; k < 4; k++) norm += q[k] * q[k];
    for (int k = 0; k < 4; k++) q[k] /= sqrt(norm);
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double rotation[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z),     2 * (x * z - w * y),
                                2 * (x * y - w * z),     1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                                2 * (x * z + w * y),     2 * (y * z - w * x),     1 - 2 * (x * x + y * y)};
    for (int k = 0; k < 9; k++) c2w[4 * (k / 3) + k % 3] = rotation[k];
    for (int k = 0; k < 3; k++) c2w[12 + k] = 5.0 * gsf_draw_normal(2, (uint64_t)k, i);
    c2w[15] = 1.0;
    gsf_set_camera_c2w(out, c2w);
    out->width = 64 + (int32_t)(i / 3);
    out->height = 48;
    out->fx = 70.25 + (double)(i / 3);
    out->fy = 71.5;
    out->cx = 31.75;
    out->cy = 24.125;
}

static void check_scene(const gsf_scene* scene, const gsf_camera* cameras, const char* prefix) {
    CHECK(scene->view_count == CAMERAS);
    for (size_t i = 0; i < scene->view_count && i < CAMERAS; i++) { // sorted by names, which count up
        const gsf_camera *a = cameras + i, *b = &scene->views[i].camera;
        char name[64];
        snprintf(name, sizeof name, "%s%05zu.png", prefix, i);
        CHECK(strcmp(scene->views[i].name, name) == 0);
        for (int k = 0; k < 16; k++) CHECK_NEAR(a->w2c[k], b->w2c[k], 1e-14 * (1.0 + fabs(a->w2c[k])) * 20.0);
        CHECK(a->width == b->width && a->height == b->height);
        CHECK_NEAR(a->fx, b->fx, 1e-12);
        CHECK_NEAR(a->fy, b->fy, 1e-12);
        CHECK_NEAR(a->cx, b->cx, 1e-12);
        CHECK_NEAR(a->cy, b->cy, 1e-12);
    }
}

static gsf_bytes read_scratch(gsf_context* ctx, const char* name) {
    gsf_bytes bytes = {NULL, 0, name};
    void* data = NULL;
    CHECK_OK(ctx, gsf_read_file(ctx, test_scratch(name), &data, &bytes.size));
    bytes.data = data;
    return bytes;
}

static void test_cameras(gsf_context* ctx) {
    gsf_camera cameras[CAMERAS];
    gsf_scene scene;
    memset(cameras, 0, sizeof cameras);
    for (uint64_t i = 0; i < CAMERAS; i++) random_camera(i, cameras + i);
    CHECK_OK(ctx, gsf_save_cameras(ctx, test_scratch("transforms.json"), cameras, NULL, CAMERAS));
    const gsf_bytes json = read_scratch(ctx, "transforms.json");
    if (CHECK_OK(ctx, gsf_splat_parse_transforms(ctx, &json, &scene))) {
        check_scene(&scene, cameras, "images/");
        gsf_splat_destroy_scene(ctx, &scene);
    }
    CHECK_OK(ctx, gsf_save_cameras(ctx, test_scratch("images.txt"), cameras, NULL, CAMERAS));
    const gsf_bytes list = read_scratch(ctx, "cameras.txt"), images = read_scratch(ctx, "images.txt");
    const gsf_bytes points = read_scratch(ctx, "points3D.txt");
    if (CHECK_OK(ctx, gsf_splat_parse_colmap(ctx, 1, &list, &images, &points, &scene))) {
        check_scene(&scene, cameras, "");
        gsf_splat_destroy_scene(ctx, &scene);
    }
    const gsf_bytes all[4] = {json, list, images, points};
    for (int i = 0; i < 4; i++) gsf_free(ctx, (void*)all[i].data);
    cameras[3].fx = -1.0; // nothing is written
    CHECK(gsf_save_cameras(ctx, test_scratch("bad/images.txt"), cameras, NULL, CAMERAS) == GSF_ERROR_INVALID_ARGUMENT);
}

static void test_pictures(gsf_context* ctx) {
    float depth[6] = {0.0f, 1.5f, -2.25f, 1e6f, 3.0f, 0.125f};
    uint16_t steps[6] = {0, 1, 255, 256, 4660, 65535};
    gsf_image image = gsf_wrap_image(depth, GSF_F32, 3, 2, 1);
    gsf_buffer file = {0};
    image.color_space = GSF_COLOR_LINEAR;
    CHECK_OK(ctx, gsf_encode_image(ctx, &image, ".exr", &file));
    const unsigned char* p = (const unsigned char*)file.data;
    const size_t line = 8 + 3 * 4, lines = file.size - 2 * line;
    CHECK(memcmp(p, "\x76\x2f\x31\x01\x02\0\0\0channels", 16) == 0);
    for (size_t y = 0; y < 2; y++) { // the table's offsets lead to the lines
        CHECK((p[lines - 16 + 8 * y] | p[lines - 15 + 8 * y] << 8) == (int)(lines + y * line));
        CHECK(p[lines + y * line] == (int)y);
        CHECK(memcmp(p + lines + y * line + 8, depth + 3 * y, 12) == 0);
    }
    gsf_destroy_buffer(ctx, &file);
    image = gsf_wrap_image(steps, GSF_U16, 3, 2, 1);
    CHECK_OK(ctx, gsf_encode_image(ctx, &image, ".png", &file));
    CHECK(file.data[24] == 16);
    gsf_image back;
    if (CHECK_OK(ctx, gsf_decode_image(ctx, "steps.png", file.data, file.size, 1, &back))) { // stb keeps the upper byte
        for (int i = 0; i < 6; i++) CHECK(((const uint8_t*)back.data)[i] == steps[i] >> 8);
        gsf_destroy_image(ctx, &back);
    }
    gsf_destroy_buffer(ctx, &file);
    image = gsf_wrap_image(depth, GSF_F32, 3, 1, 2);
    CHECK(gsf_encode_image(ctx, &image, ".exr", &file) == GSF_ERROR_INVALID_ARGUMENT);
    CHECK(file.size == 0);
    gsf_destroy_buffer(ctx, &file);
}

int main(void) {
    gsf_context ctx = {0};
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    test_cameras(&ctx);
    test_pictures(&ctx);
    return test_report();
}
