// test_scene.c - splat files, COLMAP models, transforms.json, undistortion, view images: golden data, round trips, every
// truncation, flipped bytes, failing allocations. GSF_FOX may name a folder with the fox photos (see the last test).
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"

// ---- an allocator that counts, and fails when told ------------------------------

typedef struct counter { size_t live, calls, fail_at, asked; } counter; // fail_at: 1 = the first call; 0 = never

static void* counted_alloc(void* user, size_t size) {
    counter* c = (counter*)user;
    if (++c->calls == c->fail_at) return NULL;
    c->asked += size;
    void* p = malloc(size);
    if (p) c->live++;
    return p;
}
static void counted_free(void* user, void* memory) {
    if (memory) ((counter*)user)->live--;
    free(memory);
}

static char warning[1024]; // last one logged
static int warnings;
static void keep_warning(void* user, gsf_log_level level, const char* text) {
    (void)user;
    if (level != GSF_LOG_WARNING) return;
    snprintf(warning, sizeof warning, "%s", text);
    warnings++;
}

static gsf_context make_context(counter* c) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    memset(c, 0, sizeof *c);
    ctx.allocator.alloc_fn = counted_alloc;
    ctx.allocator.free_fn = counted_free;
    ctx.allocator.user = c;
    ctx.logger.log_fn = keep_warning;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    warnings = 0;
    return ctx;
}

static char* exact_copy(const void* data, size_t size) { // so that ASan sees a read one byte behind the end
    char* p = (char*)malloc(size ? size : 1);
    if (size) memcpy(p, data, size);
    if (!size) { free(p); return NULL; }
    return p;
}

// A result that a reader may give for a file it does not take.
static int is_refusal(gsf_result r) {
    return r == GSF_ERROR_FORMAT || r == GSF_ERROR_UNSUPPORTED || r == GSF_ERROR_NUMERIC || r == GSF_ERROR_DEGENERATE;
}

// ---- PLY -----------------------------------------------------------------------

static void compare_ply(const char* file, const char* tensors, double tolerance) {
    counter count;
    gsf_context ctx = make_context(&count);
    gsf_splats s;
    if (!CHECK_OK(&ctx, gsf_splat_load_ply(&ctx, test_golden(file), &s))) return;
    test_tensors t = test_open_tensors(test_golden(tensors));
    test_tensor xyz = test_get_tensor(&t, "expect.xyz"), dc = test_get_tensor(&t, "expect.f_dc");
    test_tensor rest = test_find_tensor(&t, "expect.f_rest"), opacity = test_get_tensor(&t, "expect.opacity");
    test_tensor scaling = test_get_tensor(&t, "expect.scaling"), rotation = test_get_tensor(&t, "expect.rotation");
    const size_t n = xyz.dim[0], k = (size_t)gsf_splat_sh_count(s.sh_degree), k_rest = rest.rank > 1 ? rest.dim[1] : 0;
    CHECK(s.count == n && k == k_rest + 1);
    CHECK(s.origin[0] == 0.0 && s.origin[1] == 0.0 && s.origin[2] == 0.0);
    if (s.count == n && k == k_rest + 1) {
        test_compare_floats("xyz", s.means, xyz.v, 3 * n, tolerance);
        test_compare_floats("opacity", s.opacity_logits, opacity.v, n, tolerance);
        test_compare_floats("scaling", s.log_scales, scaling.v, 3 * n, tolerance);
        test_compare_floats("rotation", s.quats, rotation.v, 4 * n, tolerance);
        for (size_t i = 0; i < n; i++) {
            test_compare_floats("f_dc", s.sh + 3 * k * i, dc.v + 3 * i, 3, tolerance);
            if (k_rest) test_compare_floats("f_rest", s.sh + 3 * k * i + 3, rest.v + 3 * k_rest * i, 3 * k_rest, tolerance);
            CHECK(s.ids[i] == i);
        }
    }
    test_free_tensor(&xyz); test_free_tensor(&dc); test_free_tensor(&rest);
    test_free_tensor(&opacity); test_free_tensor(&scaling); test_free_tensor(&rotation);
    test_close_tensors(&t);
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

static void test_ply_golden(void) {
    compare_ply("splat/ply/small_deg0.ply", "splat/ply/small_deg0.safetensors", 0);
    compare_ply("splat/ply/small_deg1.ply", "splat/ply/small_deg1.safetensors", 0);
    compare_ply("splat/ply/small_deg2.ply", "splat/ply/small_deg2.safetensors", 0);
    compare_ply("splat/ply/small_deg1_shuffled.ply", "splat/ply/small_deg1.safetensors", 0);
    compare_ply("splat/ply/small_deg1_ascii.ply", "splat/ply/small_deg1.safetensors", 0);
    compare_ply("splat/ply/small_deg1_bigendian_double.ply", "splat/ply/small_deg1.safetensors", 0);

    counter count;
    gsf_context ctx = make_context(&count);
    gsf_splats s;
    if (!CHECK_OK(&ctx, gsf_splat_load_ply(&ctx, test_golden("splat/ply/random_deg3.ply"), &s))) return;
    test_tensors t = test_open_tensors(test_golden("splat/scenes/random.safetensors"));
    test_tensor means = test_get_tensor(&t, "in.means"), sh = test_get_tensor(&t, "in.sh");
    CHECK(s.sh_degree == 3 && 3 * s.count == means.count);
    if (3 * s.count == means.count) test_compare_floats("means", s.means, means.v, means.count, 0);
    if (48 * s.count == sh.count) test_compare_floats("sh", s.sh, sh.v, sh.count, 0);
    // and written again it is the same file
    gsf_text text;
    memset(&text, 0, sizeof text);
    size_t size;
    char* file = test_read_file(test_golden("splat/ply/random_deg3.ply"), &size);
    CHECK_OK(&ctx, gsf_splat_format_ply(&ctx, &s, &text));
    CHECK(text.size == size && memcmp(text.data, file, size) == 0);
    free(file);
    gsf_destroy_text(&ctx, &text);
    test_free_tensor(&means);
    test_free_tensor(&sh);
    test_close_tensors(&t);
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

static void test_ply_bad(void) {
    static const char* const names[] = {"00_empty", "01_truncated_body", "02_count_too_big", "03_negative_count",
                                        "04_no_end_header", "06_missing_property", "07_bad_magic", "08_count_overflow",
                                        "09_list_property", "10_frest_count_7"};
    counter count;
    gsf_context ctx = make_context(&count);
    gsf_splats s;
    for (size_t i = 0; i < sizeof names / sizeof names[0]; i++) {
        char relative[128];
        snprintf(relative, sizeof relative, "splat/bad/ply/%s.ply", names[i]);
        ctx.error[0] = 0;
        count.asked = 0;
        CHECK_RESULT(&ctx, gsf_splat_load_ply(&ctx, test_golden(relative), &s), GSF_ERROR_FORMAT);
        CHECK(strstr(ctx.error, names[i]) != NULL && s.owned == NULL && count.asked < 1000000);
    }
    CHECK_OK(&ctx, gsf_splat_load_ply(&ctx, test_golden("splat/bad/ply/05_nan_inf_xyz.ply"), &s));
    CHECK(s.count == 30 && warnings == 1 && strstr(warning, "1 of 31 splats dropped"));
    gsf_splat_destroy(&ctx, &s);
    CHECK_OK(&ctx, gsf_splat_load_ply(&ctx, test_golden("splat/bad/ply/11_huge_header.ply"), &s));
    CHECK(s.count == 31);
    gsf_splat_destroy(&ctx, &s);
    CHECK_RESULT(&ctx, gsf_splat_load_ply(&ctx, "no/such/file.ply", &s), GSF_ERROR_IO);
    CHECK(count.live == 0);
}

// Every truncation; the header's bytes each replaced by all other values, the body's by a few.
static void test_ply_damage(const char* relative, int all_values) {
    size_t size;
    char* file = test_read_file(test_golden(relative), &size);
    counter count;
    gsf_context ctx = make_context(&count);
    gsf_splats s;
    const int is_text = strstr(relative, "ascii") != NULL;
    for (size_t cut = 0; cut < size; cut++) {
        char* part = exact_copy(file, cut);
        const gsf_result r = gsf_splat_parse_ply(&ctx, "cut.ply", part, cut, &s);
        // of a text file the last number may lose digits and its line feed
        CHECK(is_text && cut + 32 > size ? r == GSF_OK || r == GSF_ERROR_FORMAT : r == GSF_ERROR_FORMAT);
        gsf_splat_destroy(&ctx, &s);
        free(part);
    }
    const char* mark = strstr(file, "end_header\n");
    const size_t header = (size_t)(mark - file) + 11;
    char* whole = exact_copy(file, size);
    for (size_t at = 0; at < size; at += at < header ? 1 : 7)
        for (int flip = 1; flip < 256; flip += at < header && all_values ? 1 : 85) {
            whole[at] = (char)(file[at] ^ flip);
            const gsf_result r = gsf_splat_parse_ply(&ctx, "flip.ply", whole, size, &s);
            CHECK(r == GSF_OK || is_refusal(r));
            if (r != GSF_OK) CHECK(strncmp(ctx.error, "flip.ply", 8) == 0 && s.owned == NULL);
            gsf_splat_destroy(&ctx, &s);
            whole[at] = file[at];
        }
    free(whole);
    free(file);
    CHECK(count.live == 0);
}

static void test_ply_out_of_memory(const char* relative) {
    size_t size;
    char* file = test_read_file(test_golden(relative), &size);
    size_t k = 1;
    for (;; k++) {
        counter count;
        gsf_context ctx = make_context(&count);
        gsf_splats s;
        count.fail_at = k;
        const gsf_result r = gsf_splat_parse_ply(&ctx, "oom.ply", file, size, &s);
        if (r == GSF_OK) {
            gsf_text text;
            memset(&text, 0, sizeof text);
            for (size_t j = 1;; j++) { // the same for writing
                count.fail_at = count.calls + j;
                const gsf_result w = gsf_splat_format_ply(&ctx, &s, &text);
                gsf_destroy_text(&ctx, &text);
                if (w == GSF_OK) break;
                CHECK(w == GSF_ERROR_OUT_OF_MEMORY);
            }
            gsf_splat_destroy(&ctx, &s);
        } else {
            CHECK(r == GSF_ERROR_OUT_OF_MEMORY && s.owned == NULL);
        }
        CHECK(count.live == 0);
        if (r == GSF_OK) break;
    }
    CHECK(k >= 3);
    free(file);
}

// Positions far from zero keep their precision through save and load; near ones give float32 columns again.
static void test_ply_origin(void) {
    counter count;
    gsf_context ctx = make_context(&count);
    gsf_splats s, again;
    CHECK_OK(&ctx, gsf_splat_make(&ctx, 500, 1, &s));
    uint64_t seed = 7;
    for (size_t i = 0; i < 3 * s.count; i++) s.means[i] = (float)test_random_in(&seed, -3, 3);
    for (size_t i = 0; i < 12 * s.count; i++) s.sh[i] = (float)test_random_in(&seed, -1, 1);
    for (size_t i = 0; i < 4 * s.count; i++) s.quats[i] = (float)test_random_in(&seed, -1, 1);
    s.means[0] = 400.0f; // a stray one
    const double far_origin[3] = {4512345.0, -331.5, 5400000.25}, near_origin[3] = {0.5, -2.0, 1.0};
    for (int turn = 0; turn < 2; turn++) {
        gsf_text text;
        memset(&text, 0, sizeof text);
        memcpy(s.origin, turn ? near_origin : far_origin, sizeof s.origin);
        CHECK_OK(&ctx, gsf_splat_format_ply(&ctx, &s, &text));
        CHECK((strstr(text.data, "property double x") != NULL) == (turn == 0));
        if (CHECK_OK(&ctx, gsf_splat_parse_ply(&ctx, "origin.ply", text.data, text.size, &again))) {
            CHECK(again.count == s.count && (again.origin[0] != 0.0) == (turn == 0));
            CHECK(again.origin[0] == floor(again.origin[0]) && again.origin[2] == floor(again.origin[2]));
            double worst = 0.0;
            for (size_t i = 0; i < 3 * s.count; i++)
                worst = fmax(worst, fabs(again.origin[i % 3] - s.origin[i % 3] + again.means[i] - s.means[i]));
            CHECK(worst < (turn ? 1e-6 : 4e-7) * 60);
            CHECK(memcmp(again.sh, s.sh, 12 * s.count * sizeof(float)) == 0);
            CHECK(memcmp(again.quats, s.quats, 4 * s.count * sizeof(float)) == 0);
            gsf_splat_destroy(&ctx, &again);
        }
        gsf_destroy_text(&ctx, &text);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

static void test_ply_variants(void) { // elements before and after, carriage returns, numbers of all kinds
    static const char text[] =
        "ply\r\nformat ascii 1.0\r\nobj_info x\r\nelement camera 2\r\nproperty int a\r\nproperty float b\r\n"
        "element nothing 18446744073709551615\r\nelement vertex 2\r\nproperty char x\r\nproperty int16 y\r\n"
        "property float64 z\r\nproperty float f_dc_0\r\nproperty float f_dc_1\r\nproperty float f_dc_2\r\n"
        "property float opacity\r\nproperty float scale_0\r\nproperty float scale_1\r\nproperty float scale_2\r\n"
        "property float rot_0\r\nproperty float rot_1\r\nproperty float rot_2\r\nproperty float rot_3\r\n"
        "element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
        "1 2\r\n3 4\r\n-5 300 1.5e0 .25 -0.1 +1E-3 12345678901234567890123 0 0 0 1 0 0 0\r\n"
        "1 2 3 4 5 6 nan 0 0 0 1 0 0 0\r\n3 0 1 2\r\n";
    counter count;
    gsf_context ctx = make_context(&count);
    gsf_splats s;
    CHECK_OK(&ctx, gsf_splat_parse_ply(&ctx, "variant.ply", text, sizeof text - 1, &s));
    CHECK(s.count == 1 && warnings == 1);
    if (s.count == 1) {
        CHECK(s.means[0] == -5.0f && s.means[1] == 300.0f && s.means[2] == 1.5f);
        CHECK(s.sh[0] == 0.25f && s.sh[1] == -0.1f && s.sh[2] == 1e-3f && s.opacity_logits[0] == 12345678901234567890123.0f);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

int main(void) {
    test_ply_golden();
    test_ply_bad();
    test_ply_damage("splat/ply/small_deg0.ply", 1);
    test_ply_damage("splat/ply/small_deg1_ascii.ply", 0);
    test_ply_damage("splat/ply/small_deg1_bigendian_double.ply", 0);
    test_ply_out_of_memory("splat/ply/small_deg1.ply");
    test_ply_out_of_memory("splat/ply/small_deg1_ascii.ply");
    test_ply_origin();
    test_ply_variants();
    return test_report();
}
