// The OpenImageIO section: round trips of EXR, TIFF and 16-bit PNG through files and memory; and OpenImageIO as an
// oracle for our decoder, gsf_measure_image and half precision.
#define GSF_USE_OIIO
#define GSFIXER_IMPLEMENTATION
#include "gsfixer.h"
#include "test.h"

#include <OpenImageIO/imagebuf.h>
#include <OpenImageIO/imagebufalgo.h>

enum { W = 37, H = 21 };

static gsf_image make_test_image(gsf_context* ctx, gsf_dtype dtype, int channels) {
    static double values[W * H * 4];
    uint64_t seed = 5;
    for (int i = 0; i < W * H * 4; i++) values[i] = test_random(&seed);
    const gsf_image source = gsf_wrap_image(values, GSF_F64, W, H, channels);
    gsf_image image;
    CHECK_OK(ctx, gsf_make_image(ctx, dtype, W, H, channels, &image));
    CHECK_OK(ctx, gsf_convert_image(ctx, &source, &image));
    return image;
}

static size_t bytes_of(const gsf_image& image) { return (size_t)(image.stride_y * image.height); }

static void check_round_trips(gsf_context* ctx) {
    static const struct { const char* name; gsf_dtype in, out; } cases[] = {
        {"a.exr", GSF_F32, GSF_F32}, {"b.exr", GSF_F16, GSF_F16}, {"c.exr", GSF_U8, GSF_F32},
        {"d.exr", GSF_F64, GSF_F32}, {"e.tif", GSF_U8, GSF_U8},   {"f.tif", GSF_U16, GSF_U16},
        {"g.TIFF", GSF_F32, GSF_F32}, {"h.tif", GSF_F64, GSF_F64}, {"i.tif", GSF_F16, GSF_F32},
        {"j.png", GSF_U16, GSF_U16}, {"k.png", GSF_U8, GSF_U8}};
    for (size_t i = 0; i < sizeof cases / sizeof *cases; i++)
        for (int channels = 1; channels <= 4; channels++) {
            if (channels == 2) continue;
            gsf_image image = make_test_image(ctx, cases[i].in, channels), back, expected;
            image.color_space = strstr(cases[i].name, ".exr") ? GSF_COLOR_LINEAR : GSF_COLOR_SRGB;
            const char* path = test_scratch(cases[i].name);
            CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
            int64_t w = 0, h = 0;
            int32_t c = 0;
            CHECK_OK(ctx, gsf_query_image(ctx, path, &w, &h, &c));
            CHECK(w == W && h == H && c == channels);
            if (CHECK_OK(ctx, gsf_load_image(ctx, path, 0, &back))) {
                CHECK(back.dtype == cases[i].out);
                CHECK(back.width == W && back.height == H && back.channels == channels);
                CHECK(back.color_space == image.color_space);
                CHECK_OK(ctx, gsf_make_image(ctx, cases[i].out, W, H, channels, &expected));
                expected.color_space = image.color_space;
                CHECK_OK(ctx, gsf_convert_image(ctx, &image, &expected));
                CHECK(bytes_of(back) == bytes_of(expected) && memcmp(back.data, expected.data, bytes_of(back)) == 0);
                gsf_destroy_image(ctx, &expected);
            }
            gsf_destroy_image(ctx, &back);
            gsf_destroy_image(ctx, &image);
        }
}

// What builds without OpenImageIO write: uncompressed EXR, and 16-bit PNG.
static void check_own_writers(gsf_context* ctx) {
    static const struct { const char* extension; gsf_dtype dtype; } cases[] = {
        {".exr", GSF_F32}, {".exr", GSF_F16}, {".png", GSF_U16}};
    for (const auto& c : cases)
        for (int channels = 1; channels <= 4; channels++) {
            if (channels == 2) continue;
            gsf_image image = make_test_image(ctx, c.dtype, channels), back;
            gsf_buffer file = {};
            if (c.dtype != GSF_U16) image.color_space = GSF_COLOR_LINEAR;
            CHECK_OK(ctx, gsf_encode_image(ctx, &image, c.extension, &file));
            const std::string name = std::string("own") + c.extension;
            if (CHECK_OK(ctx, gsf__oiio_load(ctx, name.c_str(), file.data, file.size, 0, &back))) {
                CHECK(back.dtype == c.dtype && back.width == W && back.height == H && back.channels == channels);
                CHECK(bytes_of(back) == bytes_of(image) && memcmp(back.data, image.data, bytes_of(back)) == 0);
                gsf_destroy_image(ctx, &back);
            }
            gsf_destroy_buffer(ctx, &file);
            gsf_destroy_image(ctx, &image);
        }
}

static void check_channels(gsf_context* ctx) { // what the `channels` argument does to a TIFF
    gsf_image image = make_test_image(ctx, GSF_F32, 4), back;
    const char* path = test_scratch("channels.tif");
    CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
    const float* p = (const float*)image.data;
    CHECK_OK(ctx, gsf_load_image(ctx, path, 3, &back));
    for (int i = 0; i < W * H; i++)
        for (int c = 0; c < 3; c++) CHECK(((float*)back.data)[3 * i + c] == p[4 * i + c]);
    gsf_destroy_image(ctx, &back);
    CHECK_OK(ctx, gsf_load_image(ctx, path, 1, &back));
    for (int i = 0; i < W * H; i++)
        CHECK_NEAR(((float*)back.data)[i], (77.0 * p[4 * i] + 150.0 * p[4 * i + 1] + 29.0 * p[4 * i + 2]) / 256.0,
                   1e-7);
    gsf_destroy_image(ctx, &back);
    gsf_destroy_image(ctx, &image);
    image = make_test_image(ctx, GSF_U16, 1);
    CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
    CHECK_OK(ctx, gsf_load_image(ctx, path, 4, &back));
    for (int i = 0; i < W * H; i++) {
        const uint16_t* q = (const uint16_t*)back.data + 4 * i;
        CHECK(q[0] == ((uint16_t*)image.data)[i] && q[1] == q[0] && q[2] == q[0] && q[3] == 65535);
    }
    gsf_destroy_image(ctx, &back);
    gsf_destroy_image(ctx, &image);
}

// Cut and damaged files: an error or an image, never a crash; nothing of ours remains allocated (the sanitizer checks).
static void check_damage(gsf_context* ctx) {
    static const char* const names[] = {"x.exr", "x.tif", "x.png"};
    for (int k = 0; k < 3; k++) {
        gsf_image image = make_test_image(ctx, k == 0 ? GSF_F16 : GSF_U16, 3), back;
        const char* path = test_scratch(names[k]);
        CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
        void* data;
        size_t size;
        CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
        int refused = 0, tried = 0;
        for (size_t n = 0; n < size; n += 1 + size / 97, tried++) {
            char* copy = (char*)malloc(n ? n : 1);
            memcpy(copy, data, n);
            const gsf_result result = gsf_decode_image(ctx, names[k], copy, n, 0, &back);
            refused += result != GSF_OK;
            if (result != GSF_OK) CHECK(back.data == NULL && strlen(ctx->error) > 0);
            gsf_destroy_image(ctx, &back);
            free(copy);
        }
        CHECK(refused == tried);
        gsf_free(ctx, data);
        gsf_destroy_image(ctx, &image);
    }
    gsf_image out;
    CHECK_RESULT(ctx, gsf_decode_image(ctx, "nonsense", "no image at all", 15, 0, &out), GSF_ERROR_FORMAT);
    CHECK_RESULT(ctx, gsf_load_image(ctx, test_scratch("absent.exr"), 0, &out), GSF_ERROR_NOT_FOUND);
    gsf_image image = make_test_image(ctx, GSF_F32, 3);
    CHECK_RESULT(ctx, gsf_save_image(ctx, "no/such/folder/x.exr", &image), GSF_ERROR_IO);
    CHECK_RESULT(ctx, gsf_save_image(ctx, test_scratch("x.xyz"), &image), GSF_ERROR_UNSUPPORTED);
    gsf_destroy_image(ctx, &image);
}

static void check_half(uint64_t* seed) {
    for (uint32_t bits = 0; bits < 65536; bits++) { // every half there is
        const uint16_t h = (uint16_t)bits;
        const float ours = gsf__half_to_float(h);
        float theirs = 0.0f;
        OIIO::convert_pixel_values(OIIO::TypeDesc::HALF, &h, OIIO::TypeDesc::FLOAT, &theirs);
        CHECK(memcmp(&ours, &theirs, 4) == 0 || (ours != ours && theirs != theirs));
        if (ours == ours) CHECK(gsf__float_to_half(ours) == bits);
    }
    for (int i = 0; i < 200000; i++) { // and floats, most of them around the range of half, rounded
        uint32_t bits = (uint32_t)test_random_bits(seed);
        if (i & 7) bits = (bits & 0x8fffffffu) | 0x30000000u;
        float f;
        memcpy(&f, &bits, 4);
        if (f != f) continue;
        uint16_t theirs = 0;
        OIIO::convert_pixel_values(OIIO::TypeDesc::FLOAT, &f, OIIO::TypeDesc::HALF, &theirs);
        CHECK(gsf__float_to_half(f) == theirs);
    }
}

// Same photo through OpenImageIO and through us; PSNR by ImageBufAlgo::compare and by gsf_measure_image.
static void check_oracle(gsf_context* ctx) {
    static const char* const names[] = {"landscape.png", "wide.png", "small.png", "large.png"};
    for (int k = 0; k < 4; k++) {
        char path[256];
        snprintf(path, sizeof path, "encoders/preprocess/%s", names[k]);
        OIIO::ImageSpec config;
        config.attribute("oiio:UnassociatedAlpha", 1);
        OIIO::ImageBuf theirs(test_golden(path), 0, 0, nullptr, &config);
        gsf_image ours;
        if (!CHECK_OK(ctx, gsf_load_image(ctx, test_golden(path), 0, &ours))) continue;
        CHECK(theirs.spec().width == ours.width && theirs.nchannels() == ours.channels);
        std::vector<uint8_t> pixels((size_t)(ours.width * ours.height * ours.channels));
        CHECK(theirs.get_pixels(OIIO::ROI(), OIIO::TypeDesc::UINT8, pixels.data()));
        CHECK(memcmp(pixels.data(), ours.data, pixels.size()) == 0);
        gsf_destroy_image(ctx, &ours);
    }
    uint64_t seed = 9;
    for (int k = 0; k < 6; k++) {
        const double noise = pow(10.0, -k);
        std::vector<float> a(W * H * 3), b(W * H * 3);
        for (size_t i = 0; i < a.size(); i++) {
            a[i] = (float)test_random(&seed);
            b[i] = a[i] + (float)(noise * test_random_in(&seed, -1, 1));
        }
        const OIIO::ImageSpec spec(W, H, 3, OIIO::TypeDesc::FLOAT);
        const OIIO::ImageBuf x(spec, a.data()), y(spec, b.data());
        const OIIO::ImageBufAlgo::CompareResults judged = OIIO::ImageBufAlgo::compare(x, y, 1e-3f, 1e-4f);
        const gsf_image p = gsf_wrap_image(a.data(), GSF_F32, W, H, 3), q = gsf_wrap_image(b.data(), GSF_F32, W, H, 3);
        double psnr = 0;
        CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p, &q, NULL, &psnr));
        // their peak is the largest value of the image, not 1
        float peak = 0.0f;
        for (size_t i = 0; i < a.size(); i++) peak = fmaxf(peak, fmaxf(fabsf(a[i]), fabsf(b[i])));
        CHECK_NEAR(psnr, -20.0 * log10(judged.rms_error), 1e-5);
        CHECK_NEAR(psnr + 20.0 * log10((double)peak), judged.PSNR, 0.05);
    }
    check_half(&seed);
}

int main() {
    gsf_context ctx;
    test_context_init(&ctx);
    OIIO::attribute("threads", 1);
    check_round_trips(&ctx);
    check_own_writers(&ctx);
    check_channels(&ctx);
    check_damage(&ctx);
    check_oracle(&ctx);
    return test_report();
}
