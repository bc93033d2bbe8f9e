// Resizes against golden/encoders/preprocess: PIL byte for byte (also whole pictures by their SHA-256), torch in
// float32.
#include "gsfixer.h"
#include "test.h"

// ---- SHA-256 (FIPS 180-4), one message in memory

static uint32_t rotate(uint32_t x, int n) { return x >> n | x << (32 - n); }

static void sha256_block(uint32_t state[8], const uint8_t* p) {
    static const uint32_t k[64] = {
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
        0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
        0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
        0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
        0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
        0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
        0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
    uint32_t w[64], v[8];
    for (int i = 0; i < 16; i++)
        w[i] = (uint32_t)p[4 * i] << 24 | (uint32_t)p[4 * i + 1] << 16 | (uint32_t)p[4 * i + 2] << 8 | p[4 * i + 3];
    for (int i = 16; i < 64; i++)
        w[i] = w[i - 16] + (rotate(w[i - 15], 7) ^ rotate(w[i - 15], 18) ^ w[i - 15] >> 3) + w[i - 7] +
               (rotate(w[i - 2], 17) ^ rotate(w[i - 2], 19) ^ w[i - 2] >> 10);
    memcpy(v, state, sizeof v);
    for (int i = 0; i < 64; i++) {
        const uint32_t a = v[0], e = v[4];
        const uint32_t t1 =
            v[7] + (rotate(e, 6) ^ rotate(e, 11) ^ rotate(e, 25)) + ((e & v[5]) ^ (~e & v[6])) + k[i] + w[i];
        const uint32_t t2 = (rotate(a, 2) ^ rotate(a, 13) ^ rotate(a, 22)) + ((a & v[1]) ^ (a & v[2]) ^ (v[1] & v[2]));
        memmove(v + 1, v, 7 * sizeof *v);
        v[4] += t1;
        v[0] = t1 + t2;
    }
    for (int i = 0; i < 8; i++) state[i] += v[i];
}

static void sha256_hex(const uint8_t* data, size_t size, char hex[65]) {
    uint32_t state[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                         0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    uint8_t tail[128] = {0};
    size_t whole = size / 64 * 64, rest = size - whole, tail_size = rest < 56 ? 64 : 128;
    for (size_t i = 0; i < whole; i += 64) sha256_block(state, data + i);
    memcpy(tail, data + whole, rest);
    tail[rest] = 0x80;
    for (int i = 0; i < 8; i++) tail[tail_size - 1 - (size_t)i] = (uint8_t)((uint64_t)size * 8 >> (8 * i));
    for (size_t i = 0; i < tail_size; i += 64) sha256_block(state, tail + i);
    for (int i = 0; i < 8; i++) snprintf(hex + 8 * i, 9, "%08x", (unsigned)state[i]);
}

// ---- plain resizes

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

static void check_torch_resizes(gsf_context* ctx) {
    test_tensors file = test_open_tensors(test_golden("encoders/preprocess/torch_resize.safetensors"));
    uint64_t header;
    memcpy(&header, file.data, 8);
    gsf_json json;
    CHECK_OK(ctx, gsf_parse_json(ctx, file.path, file.data + 8, (size_t)header, &json));
    test_tensor input = test_get_tensor(&file, "input_chw");
    float* in = test_tensor_floats(&input);
    gsf_image src = gsf_wrap_image(in, GSF_F32, (int64_t)input.dim[2], (int64_t)input.dim[1], 3);
    src.stride_x = 4;
    src.stride_y = 4 * src.width;
    src.stride_c = src.stride_y * src.height;
    int cases = 0;
    for (uint32_t i = json.values[0].child; i; i = json.values[i].next) {
        const char* name = json.values[i].key;
        if (strncmp(name, "bilinear_ac0_", 13) != 0) continue;
        test_tensor expected = test_get_tensor(&file, name);
        float* out = (float*)malloc(expected.count * sizeof(float));
        gsf_image dst = gsf_wrap_image(out, GSF_F32, (int64_t)expected.dim[2], (int64_t)expected.dim[1], 3);
        dst.stride_x = 4;
        dst.stride_y = 4 * dst.width;
        dst.stride_c = dst.stride_y * dst.height;
        CHECK_OK(ctx, gsf_resize_image(ctx, &src, GSF_RESIZE_TORCH_BILINEAR, &dst));
        test_compare_floats(name, out, expected.v, expected.count, 1.5e-7 * test_max_abs(expected.v, expected.count));
        size_t different = 0;
        for (size_t p = 0; p < expected.count; p++) different += (double)out[p] != expected.v[p];
        printf("%s: %zu of %zu values differ in the last bit\n", name, different, expected.count);
        free(out);
        test_free_tensor(&expected);
        cases++;
    }
    CHECK(cases > 0);
    free(in);
    test_free_tensor(&input);
    gsf_destroy_json(ctx, &json);
    test_close_tensors(&file);
}

// ---- whole pictures: the VGGT loader's "crop" mode (RGBA on white, width 518, height a multiple of 14, centre crop)

static gsf_image on_white(gsf_context* ctx, const gsf_image* image) { // PIL.Image.alpha_composite over opaque white
    gsf_image out;
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, image->width, image->height, 3, &out));
    if (image->channels != 4) {
        CHECK_OK(ctx, gsf_convert_image(ctx, image, &out));
        return out;
    }
    for (int64_t i = 0; i < image->width * image->height; i++) {
        const uint8_t* p = (const uint8_t*)image->data + 4 * i;
        for (int c = 0; c < 3; c++) {
            const uint32_t sum = p[c] * (p[3] * 128u) + 255u * (255u * 128u - p[3] * 128u) + (0x80u << 7);
            ((uint8_t*)out.data)[3 * i + c] = (uint8_t)(((sum >> 8) + sum) >> 8 >> 7);
        }
    }
    return out;
}

static double round_half_even(double x) {
    const double r = floor(x + 0.5);
    return r - x == 0.5 && fmod(r, 2.0) != 0.0 ? r - 1.0 : r;
}

static void check_pictures(gsf_context* ctx) {
    size_t size;
    char* text = test_read_file(test_golden("encoders/preprocess/expected.json"), &size);
    test_tensors sampled = test_open_tensors(test_golden("encoders/preprocess/expected_subsampled.safetensors"));
    gsf_json json;
    if (!CHECK_OK(ctx, gsf_parse_json(ctx, "expected.json", text, size, &json))) return;
    int cases = 0;
    for (uint32_t i = json.values[0].child; i; i = json.values[i].next) {
        const gsf_json_value* e = &json.values[i];
        const gsf_json_value* input = gsf_json_member(&json, e, "input");
        const gsf_json_value* shape = gsf_json_member(&json, e, "expected_shape_chw");
        if (!input || !shape) continue;
        char path[256], hex[65];
        snprintf(path, sizeof path, "encoders/preprocess/%s", input->string);
        gsf_image file, resized;
        if (!CHECK_OK(ctx, gsf_load_image(ctx, test_golden(path), 0, &file))) continue;
        gsf_image rgb = on_white(ctx, &file);
        const int64_t height = (int64_t)round_half_even((double)rgb.height * 518.0 / (double)rgb.width / 14.0) * 14;
        CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, 518, height, 3, &resized));
        CHECK_OK(ctx, gsf_resize_image(ctx, &rgb, GSF_RESIZE_PIL_BICUBIC, &resized));
        const int64_t rows = height > 518 ? 518 : height, skip = height > 518 ? (height - 518) / 2 : 0;
        const uint8_t* pixels = (const uint8_t*)resized.data + skip * 518 * 3;
        CHECK(gsf_json_element(&json, shape, 1)->number == (double)rows);
        CHECK(gsf_json_element(&json, shape, 2)->number == 518.0);
        sha256_hex(pixels, (size_t)(rows * 518 * 3), hex);
        if (!CHECK(strcmp(hex, gsf_json_member(&json, e, "sha256_of_hwc_uint8")->string) == 0))
            fprintf(stderr, "%s: SHA-256 %s\n", e->key, hex);
        test_tensor s = test_get_tensor(&sampled, e->key);
        size_t different = 0;
        for (size_t y = 0; y < s.dim[0]; y++)
            for (size_t x = 0; x < s.dim[1]; x++)
                for (size_t c = 0; c < 3; c++)
                    different += pixels[(y * 7 * 518 + x * 7) * 3 + c] != (uint8_t)s.v[(y * s.dim[1] + x) * 3 + c];
        CHECK(different == 0);
        const gsf_json_value* full = gsf_json_member(&json, e, "expected_full");
        if (full && full->type == GSF_JSON_STRING) {
            snprintf(path, sizeof path, "encoders/preprocess/%s", full->string);
            gsf_image whole;
            CHECK_OK(ctx, gsf_load_image(ctx, test_golden(path), 3, &whole));
            CHECK(whole.height == rows && memcmp(whole.data, pixels, (size_t)(rows * 518 * 3)) == 0);
            gsf_destroy_image(ctx, &whole);
        }
        test_free_tensor(&s);
        gsf_destroy_image(ctx, &file);
        gsf_destroy_image(ctx, &rgb);
        gsf_destroy_image(ctx, &resized);
        cases++;
    }
    CHECK(cases > 0);
    gsf_destroy_json(ctx, &json);
    test_close_tensors(&sampled);
    free(text);
}

static void check_misuse(gsf_context* ctx) {
    uint8_t bytes[12] = {0};
    float floats[12] = {0};
    const gsf_image u = gsf_wrap_image(bytes, GSF_U8, 2, 2, 3), f = gsf_wrap_image(floats, GSF_F32, 2, 2, 3);
    gsf_image bad = u;
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &u, GSF_RESIZE_PIL_BICUBIC, &f), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_resize_image(ctx, &u, GSF_RESIZE_TORCH_BILINEAR, &u), GSF_ERROR_INVALID_ARGUMENT);
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
    char hex[65];
    sha256_hex((const uint8_t*)"abc", 3, hex);
    CHECK(strcmp(hex, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad") == 0);
    check_pil_resizes(&ctx);
    check_torch_resizes(&ctx);
    check_pictures(&ctx);
    check_misuse(&ctx);
    return test_report();
}
