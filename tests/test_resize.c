// Resizing against golden/encoders/preprocess: PIL's filters bit-exactly. (Whole photos: golden_encoders.)
#include "gsfixer.h"
#include "test.h"

static void check_pil_resizes(gsf_context* ctx) {
    static const struct { const char* name; gsf_resize_filter filter; } prefixes[] = {
        {"bicubic_", GSF_RESIZE_PIL_BICUBIC}, {"bilinear_", GSF_RESIZE_PIL_BILINEAR},
        {"lanczos_", GSF_RESIZE_PIL_LANCZOS}, {"default_", GSF_RESIZE_PIL_BICUBIC}};
    test_tensors file = test_open_tensors(test_golden("encoders/preprocess/pil_resize.safetensors"));
    uint64_t header;
    memcpy(&header, file.data, 8);
    gsf_json json;
    CHECK_OK(ctx, gsf_parse_json(ctx, file.path, file.data + 8, (size_t)header, &json));
    test_tensor input = test_get_tensor(&file, "input");
    uint8_t* in = (uint8_t*)malloc(input.count);
    for (size_t i = 0; i < input.count; i++) in[i] = (uint8_t)input.v[i];
    const gsf_image src = gsf_wrap_image(in, GSF_U8, (int64_t)input.dim[1], (int64_t)input.dim[0], 3);
    int cases = 0;
    for (uint32_t i = json.values[0].child; i; i = json.values[i].next)
        for (size_t k = 0; k < sizeof prefixes / sizeof *prefixes; k++) {
            const char* name = json.values[i].key;
            if (strncmp(name, prefixes[k].name, strlen(prefixes[k].name)) != 0) continue;
            test_tensor expected = test_get_tensor(&file, name);
            gsf_image dst, planar;
            const int64_t w = (int64_t)expected.dim[1], h = (int64_t)expected.dim[0];
            CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, w, h, 3, &dst));
            CHECK_OK(ctx, gsf_resize_image(ctx, &src, prefixes[k].filter, &dst));
            size_t different = 0;
            for (size_t p = 0; p < expected.count; p++) different += ((uint8_t*)dst.data)[p] != (uint8_t)expected.v[p];
            if (!CHECK(different == 0))
                fprintf(stderr, "%s: %zu of %zu bytes differ\n", name, different, expected.count);
            // the same through other layouts: planar and upside down
            CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, w, h, 3, &planar));
            planar.stride_x = 1;
            planar.stride_y = -w;
            planar.stride_c = w * h;
            planar.data = (char*)planar.data + w * (h - 1);
            CHECK_OK(ctx, gsf_resize_image(ctx, &src, prefixes[k].filter, &planar));
            different = 0;
            for (int64_t y = 0; y < h; y++)
                for (int64_t x = 0; x < w; x++)
                    for (int c = 0; c < 3; c++)
                        different += ((uint8_t*)planar.data)[-y * w + x + c * w * h] !=
                                     ((uint8_t*)dst.data)[(y * w + x) * 3 + c];
            CHECK(different == 0);
            gsf_destroy_image(ctx, &planar);
            gsf_destroy_image(ctx, &dst);
            test_free_tensor(&expected);
            cases++;
        }
    CHECK(cases > 0);
    // float: the same weights without the rounding to bytes, so within one grey level of the byte result
    gsf_image fsrc, fdst, bdst;
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, src.width, src.height, 3, &fsrc));
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, 40, 31, 3, &fdst));
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, 40, 31, 3, &bdst));
    CHECK_OK(ctx, gsf_convert_image(ctx, &src, &fsrc));
    CHECK_OK(ctx, gsf_resize_image(ctx, &fsrc, GSF_RESIZE_PIL_BICUBIC, &fdst));
    CHECK_OK(ctx, gsf_resize_image(ctx, &src, GSF_RESIZE_PIL_BICUBIC, &bdst));
    double worst = 0.0;
    for (size_t p = 0; p < 40 * 31 * 3; p++) {
        const double f = fmin(fmax(((float*)fdst.data)[p] * 255.0, 0.0), 255.0);
        worst = fmax(worst, fabs(f - ((uint8_t*)bdst.data)[p]));
    }
    CHECK(worst <= 1.2);
    gsf_destroy_image(ctx, &fsrc);
    gsf_destroy_image(ctx, &fdst);
    gsf_destroy_image(ctx, &bdst);
    free(in);
    test_free_tensor(&input);
    gsf_destroy_json(ctx, &json);
    test_close_tensors(&file);
}

static void check_misuse(gsf_context* ctx) {
    uint8_t bytes[12] = {0};
    float floats[12] = {0};
    const gsf_image u = gsf_wrap_image(bytes, GSF_U8, 2, 2, 3), f = gsf_wrap_image(floats, GSF_F32, 2, 2, 3);
    gsf_image bad = u;
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &u, GSF_RESIZE_PIL_BICUBIC, &f), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &u, (gsf_resize_filter)(GSF_RESIZE_PIL_LANCZOS + 1), &u),
                 GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &u, (gsf_resize_filter)17, &u), GSF_ERROR_INVALID_ARGUMENT);
    bad.width = 0;
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &bad, GSF_RESIZE_PIL_BICUBIC, &u), GSF_ERROR_INVALID_ARGUMENT);
    bad.width = (int64_t)1 << 40;
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &u, GSF_RESIZE_PIL_BICUBIC, &bad), GSF_ERROR_UNSUPPORTED);
    bad = u;
    bad.data = NULL;
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &bad, GSF_RESIZE_PIL_BICUBIC, &u), GSF_ERROR_INVALID_ARGUMENT);
    // 1 x 1 up and down
    uint8_t one[3] = {7, 8, 9}, many[3 * 5 * 4];
    const gsf_image src = gsf_wrap_image(one, GSF_U8, 1, 1, 3), dst = gsf_wrap_image(many, GSF_U8, 5, 4, 3);
    for (int filter = 0; filter < 3; filter++) {
        CHECK_OK(ctx, gsf_resize_image(ctx, &src, (gsf_resize_filter)filter, &dst));
        for (int i = 0; i < 60; i++) CHECK(many[i] == 7 + i % 3);
        uint8_t back[3];
        const gsf_image small = gsf_wrap_image(back, GSF_U8, 1, 1, 3);
        CHECK_OK(ctx, gsf_resize_image(ctx, &dst, (gsf_resize_filter)filter, &small));
        CHECK(memcmp(back, one, 3) == 0);
    }
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    check_pil_resizes(&ctx);
    check_misuse(&ctx);
    return test_report();
}
