// PSNR, SSIM, temporal flickering and LPIPS against golden/metrics (float64 runs of the reference implementations), PSNR and
// SSIM also against direct loops in double precision, MS-SSIM against values of two packages. GSF_TEST_VERBOSE=1 prints every
// value of LPIPS.
#include "gsfixer.h"
#include "test.h"
#include "test_hooks.h"

#include "metrics_lpips.h"

typedef struct pair { // planar u8 views of the golden tensors, and packed f32 copies (value / 255)
    uint8_t *a8, *b8;
    gsf_image a, b, fa, fb;
} pair;

static uint8_t* bytes_of(const test_tensor* t) {
    uint8_t* bytes = (uint8_t*)malloc(t->count);
    for (size_t i = 0; i < t->count; i++) bytes[i] = (uint8_t)t->v[i];
    return bytes;
}

static gsf_image planar(uint8_t* data, const test_tensor* t) {
    gsf_image image = gsf_wrap_image(data, GSF_U8, (int64_t)t->dim[2], (int64_t)t->dim[1], (int32_t)t->dim[0]);
    image.stride_x = 1;
    image.stride_y = image.width;
    image.stride_c = image.width * image.height;
    return image;
}

static pair open_pair(gsf_context* ctx, const test_tensors* file, const char* name) {
    pair p;
    memset(&p, 0, sizeof p);
    char key[160];
    snprintf(key, sizeof key, "%s.a", name);
    test_tensor a = test_get_tensor(file, key);
    snprintf(key, sizeof key, "%s.b", name);
    test_tensor b = test_get_tensor(file, key);
    p.a8 = bytes_of(&a);
    p.b8 = bytes_of(&b);
    p.a = planar(p.a8, &a);
    p.b = planar(p.b8, &b);
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, p.a.width, p.a.height, p.a.channels, &p.fa));
    CHECK_OK(ctx, gsf_make_image(ctx, GSF_F32, p.a.width, p.a.height, p.a.channels, &p.fb));
    CHECK_OK(ctx, gsf_convert_image(ctx, &p.a, &p.fa));
    CHECK_OK(ctx, gsf_convert_image(ctx, &p.b, &p.fb));
    test_free_tensor(&a);
    test_free_tensor(&b);
    return p;
}

static void close_pair(gsf_context* ctx, pair* p) {
    free(p->a8);
    free(p->b8);
    gsf_destroy_image(ctx, &p->fa);
    gsf_destroy_image(ctx, &p->fb);
}

static double number_or_inf(const gsf_json* json, const gsf_json_value* object, const char* key) {
    const gsf_json_value* v = gsf_find_json_member(json, object, key);
    if (!CHECK(v != NULL)) return NAN;
    if (v->type == GSF_JSON_STRING && strcmp(v->string, "inf") == 0) return INFINITY;
    CHECK(v->type == GSF_JSON_NUMBER);
    return v->number;
}

static double at(const gsf_image* image, int64_t x, int64_t y, int32_t c) {
    const char* p = (const char*)image->data + y * image->stride_y + x * image->stride_x + c * image->stride_c;
    return image->dtype == GSF_U8 ? *(const uint8_t*)p / 255.0 : (double)*(const float*)(const void*)p;
}

// scikit-image's default SSIM as its documentation defines it, implemented directly. mask may be NULL.
static double plain_ssim_skimage(const gsf_image* a, const gsf_image* b, const gsf_image* mask) {
    double sum = 0.0;
    int64_t count = 0;
    for (int32_t c = 0; c < a->channels; c++)
        for (int64_t y = 3; y < a->height - 3; y++)
            for (int64_t x = 3; x < a->width - 3; x++) {
                if (mask && !((const uint8_t*)mask->data)[y * mask->stride_y + x]) continue;
                double ma = 0.0, mb = 0.0, va = 0.0, vb = 0.0, cov = 0.0;
                for (int64_t j = -3; j <= 3; j++)
                    for (int64_t i = -3; i <= 3; i++) {
                        ma += at(a, x + i, y + j, c) / 49.0;
                        mb += at(b, x + i, y + j, c) / 49.0;
                    }
                for (int64_t j = -3; j <= 3; j++)
                    for (int64_t i = -3; i <= 3; i++) {
                        const double da = at(a, x + i, y + j, c) - ma, db = at(b, x + i, y + j, c) - mb;
                        va += da * da / 48.0;
                        vb += db * db / 48.0;
                        cov += da * db / 48.0;
                    }
                sum += (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
                count++;
            }
    return sum / (double)count;
}

// The 3DGS SSIM with its full 11x11 window, zeros outside. The window is the outer product of two float32 rows,
// rounded to float32 again; gsf_measure_image applies the two rows separately, with the same sum.
static double plain_ssim_3dgs(const gsf_image* a, const gsf_image* b, const gsf_image* mask) {
    // float32 of exp(-x^2/4.5) / sum, the sum taken in torch's order
    static const float kernel[11] = {0.00102838012f, 0.00759875821f, 0.0360007733f, 0.109360687f,
                                     0.213005528f,   0.266011715f,   0.213005528f,  0.109360687f,
                                     0.0360007733f,  0.00759875821f, 0.00102838012f};
    double sum = 0.0;
    int64_t count = 0;
    for (int32_t c = 0; c < a->channels; c++)
        for (int64_t y = 0; y < a->height; y++)
            for (int64_t x = 0; x < a->width; x++) {
                if (mask && !((const uint8_t*)mask->data)[y * mask->stride_y + x]) continue;
                double m[5] = {0};
                for (int64_t j = -5; j <= 5; j++)
                    for (int64_t i = -5; i <= 5; i++) {
                        if (x + i < 0 || x + i >= a->width || y + j < 0 || y + j >= a->height) continue;
                        const double w = (double)(kernel[i + 5] * kernel[j + 5]);
                        const double va = at(a, x + i, y + j, c), vb = at(b, x + i, y + j, c);
                        m[0] += w * va;
                        m[1] += w * vb;
                        m[2] += w * va * va;
                        m[3] += w * vb * vb;
                        m[4] += w * va * vb;
                    }
                sum += (2 * m[0] * m[1] + 1e-4) * (2 * (m[4] - m[0] * m[1]) + 9e-4) /
                       ((m[0] * m[0] + m[1] * m[1] + 1e-4) * (m[2] - m[0] * m[0] + m[3] - m[1] * m[1] + 9e-4));
                count++;
            }
    return sum / (double)count;
}

static uint64_t hash_pixels(const pair* p) { // FNV-1a of both images
    uint64_t hash = 14695981039346656037u;
    const size_t n = (size_t)(p->a.stride_c * p->a.channels);
    for (size_t i = 0; i < 2 * n; i++) hash = (hash ^ (i < n ? p->a8[i] : p->b8[i - n])) * 1099511628211u;
    return hash;
}

// structural_similarity(a / 255, b / 255, data_range=1.0, channel_axis=0) of scikit-image 0.26.0 on the committed
// pairs; the hash verifies that the golden folder in use holds the same pixels.
static const struct { const char* name; uint64_t hash; double ssim; } skimage[] = {
    {"black_white", 14272087802833798949u, 9.9990000999899988e-05},
    {"blur", 11848061275429587887u, 0.70729096266230229},
    {"const_vs_photo", 2926902778186866018u, 0.10907518999232181},
    {"constant_diff", 3831199486394500901u, 0.60257249851702466},
    {"constant_same", 2190053274580927269u, 1.0},
    {"identical", 3794864948692015305u, 1.0},
    {"noisy", 13124684805246906408u, 0.49586691650434905},
    {"shift", 11579223908024274941u, 0.59193738563548637},
    {"unrelated_small", 6992804744699737u, 0.21214576962579482},
};

static void check_pair(gsf_context* ctx, const gsf_json* json, const gsf_json_value* e, const pair* p) {
    const char* name = e->key;
    double got = NAN;
    const double psnr = number_or_inf(json, e, "psnr"), tg = number_or_inf(json, e, "ssim_3dgs");
    // The references read the photo as float32, so on the f32 images only rounding differs; the u8 images represent the
    // exact v/255, which moves a PSNR by up to 1e-6 dB.
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p->fa, &p->fb, NULL, &got));
    test_compare(name, &got, &psnr, 1, 1e-9);
    if (!isinf(psnr)) test_note_error("psnr", fabs(got - psnr));
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p->a, &p->b, NULL, &got));
    test_compare(name, &got, &psnr, 1, 2e-6);
    CHECK_NEAR(got, number_or_inf(json, e, "psnr_torchmetrics"), 1e-4);
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p->a, &p->fb, NULL, &got));
    if (isinf(psnr)) CHECK(got > 140.0); // u8 against its own float32 rounding
    else test_compare(name, &got, &psnr, 1, 2e-6);

    const double l1 = number_or_inf(json, e, "l1");
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_DIFFERENCE, &p->a, &p->b, NULL, &got));
    test_compare(name, &got, &l1, 1, 1e-7);

    const double plain = plain_ssim_3dgs(&p->fa, &p->fb, NULL);
    test_compare(name, &plain, &tg, 1, 1e-9);
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_3DGS, &p->fa, &p->fb, NULL, &got));
    test_compare(name, &got, &tg, 1, 1e-8);
    test_note_error("ssim_3dgs", fabs(got - tg));
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_3DGS, &p->a, &p->b, NULL, &got));
    test_compare(name, &got, &tg, 1, 2e-7);

    const double tm = number_or_inf(json, e, "ssim_torchmetrics");
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_TORCHMETRICS, &p->fa, &p->fb, NULL, &got));
    test_compare(name, &got, &tm, 1, 1e-11);
    test_note_error("ssim_torchmetrics", fabs(got - tm));
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_TORCHMETRICS, &p->a, &p->b, NULL, &got));
    test_compare(name, &got, &tm, 1, 1e-7);

    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_SKIMAGE, &p->a, &p->b, NULL, &got));
    const double sk = plain_ssim_skimage(&p->a, &p->b, NULL);
    test_compare(name, &got, &sk, 1, 1e-12);
    test_note_error("ssim_skimage", fabs(got - sk));
    for (size_t i = 0; i < sizeof skimage / sizeof *skimage; i++)
        if (skimage[i].hash == hash_pixels(p)) test_compare(skimage[i].name, &got, &skimage[i].ssim, 1, 1e-12);
}

static void check_masks(gsf_context* ctx, const pair* p) {
    const size_t n = (size_t)(p->a.width * p->a.height);
    uint8_t* bytes = (uint8_t*)malloc(n);
    uint64_t seed = 7;
    gsf_image mask = gsf_wrap_image(bytes, GSF_U8, p->a.width, p->a.height, 1);
    double got = NAN, all = NAN;
    for (int kind = GSF_METRIC_SSIM_3DGS; kind <= GSF_METRIC_SSIM_SKIMAGE; kind++) {
        memset(bytes, 1, n);
        CHECK_OK(ctx, gsf_measure_image(ctx, (gsf_metric)kind, &p->a, &p->b, &mask, &got));
        CHECK_OK(ctx, gsf_measure_image(ctx, (gsf_metric)kind, &p->a, &p->b, NULL, &all));
        CHECK(got == all);
        memset(bytes, 0, n);
        bytes[0] = kind != GSF_METRIC_SSIM_SKIMAGE; // no window of scikit-image fits at the corner
        CHECK_RESULT(ctx, gsf_measure_image(ctx, (gsf_metric)kind, &p->a, &p->b, &mask, &got),
                     kind == GSF_METRIC_SSIM_SKIMAGE ? GSF_ERROR_DEGENERATE : GSF_OK);
    }
    double sum = 0.0, counted = 0.0;
    for (size_t i = 0; i < n; i++) {
        bytes[i] = (uint8_t)(test_random(&seed) < 0.3 ? 1 + i % 255 : 0);
        for (int c = 0; c < 3 && bytes[i]; c++) {
            const double d = at(&p->a, (int64_t)i % p->a.width, (int64_t)i / p->a.width, c) -
                             at(&p->b, (int64_t)i % p->a.width, (int64_t)i / p->a.width, c);
            sum += d * d;
            counted += 1.0;
        }
    }
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p->a, &p->b, &mask, &got));
    CHECK_NEAR(got, 20.0 * log10(1.0 / sqrt(sum / counted)), 1e-10);
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_SKIMAGE, &p->a, &p->b, &mask, &got));
    CHECK_NEAR(got, plain_ssim_skimage(&p->a, &p->b, &mask), 1e-12);
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_3DGS, &p->a, &p->b, &mask, &got));
    CHECK_NEAR(got, plain_ssim_3dgs(&p->a, &p->b, &mask), 1e-7);
    memset(bytes, 0, n);
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p->a, &p->b, &mask, &got), GSF_ERROR_DEGENERATE);
    mask.dtype = GSF_F32;
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &p->a, &p->b, &mask, &got), GSF_ERROR_INVALID_ARGUMENT);
    free(bytes);
}

// Bit-identical for any worker count and instruction set, on a noise image large enough for several chunks.
static void check_determinism(gsf_context* ctx) {
    enum { W = 211, H = 177 };
    static float a[W * H * 3], b[W * H * 3];
    uint64_t seed = 3;
    for (size_t i = 0; i < W * H * 3; i++) {
        a[i] = (float)test_random(&seed);
        b[i] = a[i] + (float)test_random_in(&seed, -0.1, 0.1);
    }
    const gsf_image x = gsf_wrap_image(a, GSF_F32, W, H, 3), y = gsf_wrap_image(b, GSF_F32, W, H, 3);
    gsf_context other;
    test_context_zero(&other);
    work_backwards(&other);
    CHECK_OK(&other, gsf_init_context(&other));
    gsf_context scalar;
    memset(&scalar, 0, sizeof scalar);
    scalar.cpu_level = GSF_CPU_SCALAR;
    CHECK_OK(&scalar, gsf_init_context(&scalar));
    double one = 0, three = 1, plain = 2;
    for (int kind = 0; kind <= GSF_METRIC_MS_SSIM_TORCHMETRICS; kind++) {
        CHECK_OK(ctx, gsf_measure_image(ctx, (gsf_metric)kind, &x, &y, NULL, &one));
        CHECK_OK(&other, gsf_measure_image(&other, (gsf_metric)kind, &x, &y, NULL, &three));
        CHECK_OK(&scalar, gsf_measure_image(&scalar, (gsf_metric)kind, &x, &y, NULL, &plain));
        CHECK(one == three);
        CHECK(one == plain);
    }
    a[777] = NAN;
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &x, &y, NULL, &one), GSF_ERROR_NUMERIC);
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_3DGS, &x, &y, NULL, &one), GSF_ERROR_NUMERIC);
    a[777] = INFINITY;
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &x, &y, NULL, &one), GSF_ERROR_NUMERIC);
    gsf_image narrow = x;
    narrow.width--;
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_PSNR, &narrow, &y, NULL, &one), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_measure_image(ctx, (gsf_metric)9, &y, &y, NULL, &one), GSF_ERROR_INVALID_ARGUMENT);
    gsf_image tiny = y;
    tiny.width = 5;
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_TORCHMETRICS, &tiny, &tiny, NULL, &one), GSF_ERROR_DEGENERATE);
    CHECK_RESULT(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_SKIMAGE, &tiny, &tiny, NULL, &one), GSF_ERROR_DEGENERATE);
    tiny.width = tiny.height = 1;
    CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_SSIM_3DGS, &tiny, &tiny, NULL, &one));
    CHECK(one == 1.0);
}

// MS-SSIM of two images given by a formula, against pytorch-msssim 1.0.0 and torchmetrics 1.9.0 in float64:
//     y, x, c = np.meshgrid(np.arange(h), np.arange(w), np.arange(3), indexing="ij")
//     a = 128 + 60 * (x // (5 + c) % 2) - 30 + 40 * (y // 9 % 2) - 20 + x * y % 31 - 15
//     b = np.clip(a + (x * 31 + y * 17 + c * 7) % 81 - 40, 0, 255)
//     a, b = (torch.from_numpy((v / 255).transpose(2, 0, 1)[None]) for v in (a, b))
//     ms_ssim(a, b, data_range=1.0)
//     multiscale_structural_similarity_index_measure(a, b, data_range=1.0, normalize="relu")
static void check_multiscale(gsf_context* ctx) {
    static const struct { int height, width; double expected[2]; } sizes[] = {
        {176, 176, {0.9741351139, 0.9741640015}}, {203, 181, {0.9732706694, 0.9742423293}}};
    for (int i = 0; i < 2; i++) {
        const int h = sizes[i].height, w = sizes[i].width;
        uint8_t* bytes = (uint8_t*)malloc((size_t)(2 * 3 * h * w));
        gsf_image a = gsf_wrap_image(bytes, GSF_U8, w, h, 3), b = gsf_wrap_image(bytes + 3 * h * w, GSF_U8, w, h, 3);
        for (int at = 0; at < 3 * h * w; at++) {
            const int c = at % 3, x = at / 3 % w, y = at / 3 / w;
            const int v = 128 + 60 * (x / (5 + c) % 2) - 30 + 40 * (y / 9 % 2) - 20 + x * y % 31 - 15;
            const int changed = v + (x * 31 + y * 17 + c * 7) % 81 - 40;
            bytes[at] = (uint8_t)v;
            bytes[3 * h * w + at] = (uint8_t)(changed < 0 ? 0 : changed > 255 ? 255 : changed);
        }
        for (int kind = 0; kind < 2; kind++) {
            const gsf_metric k = kind ? GSF_METRIC_MS_SSIM_TORCHMETRICS : GSF_METRIC_MS_SSIM;
            double got = 0.0;
            CHECK_OK(ctx, gsf_measure_image(ctx, k, &a, &b, NULL, &got));
            CHECK_NEAR(got, sizes[i].expected[kind], 1e-7);
            test_note_error(kind ? "ms_ssim_torchmetrics" : "ms_ssim", fabs(got - sizes[i].expected[kind]));
            CHECK_OK(ctx, gsf_measure_image(ctx, k, &a, &a, NULL, &got));
            CHECK_NEAR(got, 1.0, 1e-12);
            gsf_image small = a, mask = gsf_wrap_image(bytes, GSF_U8, w, h, 1);
            small.height = kind ? 175 : 160;
            CHECK_RESULT(ctx, gsf_measure_image(ctx, k, &small, &small, NULL, &got), GSF_ERROR_DEGENERATE);
            CHECK_RESULT(ctx, gsf_measure_image(ctx, k, &a, &b, &mask, &got), GSF_ERROR_INVALID_ARGUMENT);
        }
        free(bytes);
    }
}

// Temporal flickering of every clip tf.*, from differences of successive frames.
static void check_flickering(gsf_context* ctx) {
    test_tensors file = test_open_tensors(test_golden("metrics/vbench.safetensors"));
    size_t size;
    char* text = test_read_file(test_golden("metrics/vbench_expected.json"), &size);
    gsf_json json;
    int clips = 0;
    if (!CHECK_OK(ctx, gsf_parse_json(ctx, "vbench_expected.json", text, size, &json))) return;
    for (uint32_t i = json.values[0].child; i; i = json.values[i].next) {
        if (strncmp(json.values[i].key, "tf.", 3) != 0) continue;
        char name[96];
        snprintf(name, sizeof name, "%s.frames", json.values[i].key);
        test_tensor t = test_find_tensor(&file, name);
        double sum = 0.0, now = 0.0;
        if (!CHECK(t.v && t.rank == 4)) continue;
        const size_t frame = t.dim[1] * t.dim[2] * t.dim[3];
        uint8_t* bytes = bytes_of(&t);
        for (size_t k = 0; k + 1 < t.dim[0]; k++) {
            const gsf_image a = gsf_wrap_image(bytes + k * frame, GSF_U8, (int64_t)t.dim[2], (int64_t)t.dim[1],
                                               (int32_t)t.dim[3]);
            const gsf_image b = gsf_wrap_image(bytes + (k + 1) * frame, GSF_U8, a.width, a.height, a.channels);
            CHECK_OK(ctx, gsf_measure_image(ctx, GSF_METRIC_DIFFERENCE, &a, &b, NULL, &now));
            sum += now;
        }
        const double score = 1.0 - sum / (double)(t.dim[0] - 1);
        CHECK_NEAR(score, json.values[i].number, 1e-6); // the reference averages in float32
        test_note_error("temporal_flickering", fabs(score - json.values[i].number));
        free(bytes);
        test_free_tensor(&t);
        clips++;
    }
    CHECK(clips > 0);
    gsf_destroy_json(ctx, &json);
    test_close_tensors(&file);
    free(text);
}

int main(void) {
    gsf_context ctx;
    test_context_zero(&ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    test_tensors file = test_open_tensors(test_golden("metrics/pairs.safetensors"));
    test_tensors features = test_open_tensors(test_golden("metrics/lpips_small_features.safetensors"));
    lpips_net nets[LPIPS_NETS] = {0};
    size_t size;
    char* text = test_read_file(test_golden("metrics/expected.json"), &size);
    gsf_json json;
    if (!CHECK_OK(&ctx, gsf_parse_json(&ctx, "expected.json", text, size, &json))) return test_report();
    CHECK(json.values[0].count > 0);
    if (!lpips_open(&ctx, nets)) return test_report();
    for (uint32_t i = json.values[0].child; i; i = json.values[i].next) {
        pair p = open_pair(&ctx, &file, json.values[i].key);
        check_pair(&ctx, &json, &json.values[i], &p);
        check_masks(&ctx, &p);
        lpips_check_pair(&ctx, nets, &features, &json, &json.values[i], &p.a, &p.b);
        if (i == json.values[0].child)
            for (int k = 0; k < LPIPS_NETS; k++) lpips_check_stream(&ctx, &nets[k], &p.a, &p.b);
        close_pair(&ctx, &p);
    }
    check_determinism(&ctx);
    check_multiscale(&ctx);
    check_flickering(&ctx);
    lpips_close(&ctx, nets);
    gsf_destroy_json(&ctx, &json);
    test_close_tensors(&file);
    test_close_tensors(&features);
    free(text);
    return test_report();
}
