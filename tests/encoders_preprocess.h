// encoders_preprocess.h - preprocessing of reference photos as in the GSFixer release, bit-exact.
#ifndef ENCODERS_PREPROCESS_H
#define ENCODERS_PREPROCESS_H

#include "encoders_golden.h"
#include "sha256.h"

static const char* preprocess_path(const char* name) {
    char relative[512];
    snprintf(relative, sizeof relative, "encoders/preprocess/%s", name);
    return test_golden(relative);
}

static void check_photo(gsf_context* ctx, const gsf_json* json, const gsf_json_value* entry, const test_tensors* samples) {
    const char* input = gsf_find_json_member(json, entry, "input")->string;
    const gsf_json_value* shape = gsf_find_json_member(json, entry, "expected_shape_chw");
    const gsf_json_value* full = gsf_find_json_member(json, entry, "expected_full");
    gsf_image photo, image, wide;
    char hex[65];
    CHECK_OK(ctx, gsf_load_image(ctx, preprocess_path(input), 0, &photo));
    if (!CHECK_OK(ctx, gsf__nn_prepare_reference(ctx, &photo, &image))) return;
    CHECK(image.channels == 3 && image.dtype == GSF_U8);
    CHECK(image.height == (int64_t)gsf_find_json_element(json, shape, 1)->number);
    CHECK(image.width == (int64_t)gsf_find_json_element(json, shape, 2)->number);
    const uint8_t* pixels = (const uint8_t*)image.data;
    const size_t count = (size_t)(image.width * image.height * 3);
    double sum = 0.0;
    for (size_t i = 0; i < count; i++) sum += pixels[i];
    CHECK(sum == gsf_find_json_member(json, entry, "sum")->number);
    const gsf_json_value* row = gsf_find_json_member(json, entry, "first_row_rgb");
    for (size_t i = 0; i < row->count; i++)
        for (size_t k = 0; k < 3; k++)
            CHECK(pixels[3 * i + k] == gsf_find_json_element(json, gsf_find_json_element(json, row, i), k)->number);
    test_tensor sample = test_get_tensor(samples, entry->key);
    size_t wrong = 0, at = 0;
    for (int64_t y = 0; y < image.height; y += 7)
        for (int64_t x = 0; x < image.width; x += 7)
            for (int64_t c = 0; c < 3; c++, at++)
                wrong += at >= sample.count || (double)pixels[(y * image.width + x) * 3 + c] != sample.v[at];
    CHECK(wrong == 0 && at == sample.count);
    test_free_tensor(&sample);
    sha256(pixels, count, hex);
    if (!CHECK(strcmp(hex, gsf_find_json_member(json, entry, "sha256_of_hwc_uint8")->string) == 0))
        fprintf(stderr, "    %s has sha256 %s\n", input, hex);
    if (full->type == GSF_JSON_STRING) {
        gsf_image expected;
        CHECK_OK(ctx, gsf_load_image(ctx, preprocess_path(full->string), 3, &expected));
        CHECK(expected.width == image.width && expected.height == image.height &&
              memcmp(expected.data, pixels, count) == 0);
        gsf_destroy_image(ctx, &expected);
    }
    // a float photo gives the same result
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, photo.width, photo.height, photo.channels, &wide));
    CHECK_OK(ctx, gsf_convert_image(ctx, &photo, &wide));
    gsf_destroy_image(ctx, &image);
    CHECK_OK(ctx, gsf__nn_prepare_reference(ctx, &wide, &image));
    sha256(image.data, count, hex);
    CHECK(strcmp(hex, gsf_find_json_member(json, entry, "sha256_of_hwc_uint8")->string) == 0);
    gsf_destroy_image(ctx, &wide);
    gsf_destroy_image(ctx, &image);
    gsf_destroy_image(ctx, &photo);
}

static void check_preprocess(void) {
    gsf_context ctx;
    gsf_json json;
    size_t size;
    char hex[65];
    test_context_init(&ctx);
    sha256("abc", 3, hex);
    CHECK(strcmp(hex, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad") == 0);
    char* text = test_read_file(preprocess_path("expected.json"), &size);
    if (!CHECK_OK(&ctx, gsf_parse_json(&ctx, "expected.json", text, size, &json))) return;
    test_tensors samples = test_open_tensors(preprocess_path("expected_subsampled.safetensors"));
    int photos = 0;
    for (uint32_t i = json.values[0].child; i; i = json.values[i].next, photos++)
        check_photo(&ctx, &json, &json.values[i], &samples);
    CHECK(photos > 0);
    test_close_tensors(&samples);
    gsf_destroy_json(&ctx, &json);
    free(text);
}

#endif
