// test_scene.c - splat files, COLMAP models, transforms.json, undistortion, view images: golden data, round trips,
// every truncation, flipped bytes, failing allocations. GSF_FOX may name a folder with the fox photos (see the last
// test).
#define _DEFAULT_SOURCE 1 // symlink, mkfifo
#define GSFIXER_IMPLEMENTATION
#include <sys/stat.h>
#include <unistd.h>
#include "gsfixer_splat.h"
#include "test.h"
#include "test_hooks.h"

static gsf_context make_counted_context(counter* c) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    memset(c, 0, sizeof *c);
    count_memory(&ctx, c);
    ctx.logger.log_fn = keep_warning;
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    warnings = 0;
    return ctx;
}

// Results with which a reader may refuse an invalid file.
static int is_reader_refusal(gsf_result r) {
    return r == GSF_ERROR_FORMAT || r == GSF_ERROR_UNSUPPORTED || r == GSF_ERROR_NUMERIC || r == GSF_ERROR_DEGENERATE;
}

// ---- PLY -----------------------------------------------------------------------

static void compare_ply(const char* file, const char* tensors, double tolerance) {
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_splats s;
    if (!CHECK_OK(&ctx, gsf_splat_load(&ctx, test_golden(file), &s))) return;
    test_tensors t = test_open_tensors(test_golden(tensors));
    test_tensor xyz = test_get_tensor(&t, "expect.xyz"), dc = test_get_tensor(&t, "expect.f_dc");
    test_tensor rest = test_find_tensor(&t, "expect.f_rest"), opacity = test_get_tensor(&t, "expect.opacity");
    test_tensor scaling = test_get_tensor(&t, "expect.scaling"), rotation = test_get_tensor(&t, "expect.rotation");
    const size_t n = xyz.dim[0], k = (size_t)gsf_splat_count_sh(s.sh_degree), k_rest = rest.rank > 1 ? rest.dim[1] : 0;
    CHECK(s.count == n && k == k_rest + 1);
    CHECK(s.origin[0] == 0.0 && s.origin[1] == 0.0 && s.origin[2] == 0.0);
    if (s.count == n && k == k_rest + 1) {
        test_compare_floats("xyz", s.means, xyz.v, 3 * n, tolerance);
        test_compare_floats("opacity", s.opacity_logits, opacity.v, n, tolerance);
        test_compare_floats("scaling", s.log_scales, scaling.v, 3 * n, tolerance);
        test_compare_floats("rotation", s.quats, rotation.v, 4 * n, tolerance);
        for (size_t i = 0; i < n; i++) {
            test_compare_floats("f_dc", s.sh + 3 * k * i, dc.v + 3 * i, 3, tolerance);
            if (k_rest)
                test_compare_floats("f_rest", s.sh + 3 * k * i + 3, rest.v + 3 * k_rest * i, 3 * k_rest, tolerance);
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
    gsf_context ctx = make_counted_context(&count);
    gsf_splats s;
    if (!CHECK_OK(&ctx, gsf_splat_load(&ctx, test_golden("splat/ply/random_deg3.ply"), &s))) return;
    test_tensors t = test_open_tensors(test_golden("splat/scenes/random.safetensors"));
    test_tensor means = test_get_tensor(&t, "in.means"), sh = test_get_tensor(&t, "in.sh");
    CHECK(s.sh_degree == 3 && 3 * s.count == means.count);
    if (3 * s.count == means.count) test_compare_floats("means", s.means, means.v, means.count, 0);
    if (48 * s.count == sh.count) test_compare_floats("sh", s.sh, sh.v, sh.count, 0);
    // and written again it is the same file
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    size_t size;
    char* file = test_read_file(test_golden("splat/ply/random_deg3.ply"), &size);
    CHECK_OK(&ctx, gsf_splat_format(&ctx, "x.ply", &s, NULL, &text));
    CHECK(text.size == size && memcmp(text.data, file, size) == 0);
    free(file);
    gsf_destroy_buffer(&ctx, &text);
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
    gsf_context ctx = make_counted_context(&count);
    gsf_splats s;
    for (size_t i = 0; i < sizeof names / sizeof names[0]; i++) {
        char relative[128];
        snprintf(relative, sizeof relative, "splat/bad/ply/%s.ply", names[i]);
        ctx.error[0] = 0;
        count.asked = 0;
        CHECK_RESULT(&ctx, gsf_splat_load(&ctx, test_golden(relative), &s), GSF_ERROR_FORMAT);
        CHECK(strstr(ctx.error, names[i]) != NULL && s.owned == NULL && count.asked < 1000000);
    }
    CHECK_OK(&ctx, gsf_splat_load(&ctx, test_golden("splat/bad/ply/05_nan_inf_xyz.ply"), &s));
    CHECK(s.count == 30 && warnings == 1 && strstr(warning, "1 of 31 splats dropped"));
    gsf_splat_destroy(&ctx, &s);
    CHECK_OK(&ctx, gsf_splat_load(&ctx, test_golden("splat/bad/ply/11_huge_header.ply"), &s));
    CHECK(s.count == 31);
    gsf_splat_destroy(&ctx, &s);
    CHECK_RESULT(&ctx, gsf_splat_load(&ctx, "no/such/file.ply", &s), GSF_ERROR_NOT_FOUND);
    CHECK(count.live == 0);
}

// Every truncation; each byte of the header replaced by all other values, each byte of the body by a few.
static void test_ply_damage(const char* relative, int all_values) {
    size_t size;
    char* file = test_read_file(test_golden(relative), &size);
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_splats s;
    const int32_t is_text = strstr(relative, "ascii") != NULL;
    for (size_t cut = 0; cut < size; cut++) {
        char* part = (char*)exact_copy(file, cut);
        const gsf_result r = gsf_splat_parse(&ctx, "cut.ply", part, cut, &s);
        // the last number of a text file may lose digits and its line feed
        CHECK(is_text && cut + 32 > size ? r == GSF_OK || r == GSF_ERROR_FORMAT : r == GSF_ERROR_FORMAT);
        gsf_splat_destroy(&ctx, &s);
        free(part);
    }
    const char* mark = strstr(file, "end_header\n");
    const size_t header = (size_t)(mark - file) + 11;
    char* whole = (char*)exact_copy(file, size);
    for (size_t at = 0; at < size; at += at < header ? 1 : 7)
        for (int flip = 1; flip < 256; flip += at < header && all_values ? 1 : 85) {
            whole[at] = (char)(file[at] ^ flip);
            const gsf_result r = gsf_splat_parse(&ctx, "flip.ply", whole, size, &s);
            CHECK(r == GSF_OK || is_reader_refusal(r));
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
        gsf_context ctx = make_counted_context(&count);
        gsf_splats s;
        count.fail_at = k;
        const gsf_result r = gsf_splat_parse(&ctx, "oom.ply", file, size, &s);
        if (r == GSF_OK) {
            gsf_buffer text;
            memset(&text, 0, sizeof text);
            for (size_t j = 1;; j++) { // then failures while writing
                count.fail_at = count.calls + j;
                const gsf_result w = gsf_splat_format(&ctx, "x.ply", &s, NULL, &text);
                gsf_destroy_buffer(&ctx, &text);
                if (w == GSF_OK) break;
                if (!CHECK(w == GSF_ERROR_OUT_OF_MEMORY)) break;
            }
            gsf_splat_destroy(&ctx, &s);
        }
        CHECK(count.live == 0);
        if (r == GSF_OK || !CHECK(r == GSF_ERROR_OUT_OF_MEMORY && s.owned == NULL)) break;
    }
    CHECK(k >= 3);
    free(file);
}

// Positions far from zero keep their precision when saved and loaded; those near zero are saved as float32.
static void test_ply_origin(void) {
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_splats s, again;
    CHECK_OK(&ctx, gsf_splat_make(&ctx, 500, 1, &s));
    uint64_t seed = 7;
    for (size_t i = 0; i < 3 * s.count; i++) s.means[i] = (float)test_random_in(&seed, -3, 3);
    for (size_t i = 0; i < 12 * s.count; i++) s.sh[i] = (float)test_random_in(&seed, -1, 1);
    for (size_t i = 0; i < 4 * s.count; i++) s.quats[i] = (float)test_random_in(&seed, -1, 1);
    s.means[0] = 400.0f; // a stray one
    const double far_origin[3] = {4512345.0, -331.5, 5400000.25}, near_origin[3] = {0.5, -2.0, 1.0};
    for (int turn = 0; turn < 2; turn++) {
        gsf_buffer text;
        memset(&text, 0, sizeof text);
        memcpy(s.origin, turn ? near_origin : far_origin, sizeof s.origin);
        CHECK_OK(&ctx, gsf_splat_format(&ctx, "x.ply", &s, NULL, &text));
        CHECK((strstr(text.data, "property double x") != NULL) == (turn == 0));
        if (CHECK_OK(&ctx, gsf_splat_parse(&ctx, "origin.ply", text.data, text.size, &again))) {
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
        gsf_destroy_buffer(&ctx, &text);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

static void test_ply_variants(void) { // elements before and after the vertices, carriage returns, all kinds of numbers
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
    gsf_context ctx = make_counted_context(&count);
    gsf_splats s;
    CHECK_OK(&ctx, gsf_splat_parse(&ctx, "variant.ply", text, sizeof text - 1, &s));
    CHECK(s.count == 1 && warnings == 1);
    if (s.count == 1) {
        CHECK(s.means[0] == -5.0f && s.means[1] == 300.0f && s.means[2] == 1.5f);
        CHECK(s.sh[0] == 0.25f && s.sh[1] == -0.1f && s.sh[2] == 1e-3f &&
              s.opacity_logits[0] == 12345678901234567890123.0f);
    }
    gsf_splat_destroy(&ctx, &s);
    CHECK(count.live == 0);
}

// ---- files in memory, through the io hook ---------------------------------------

typedef struct memory_file { char path[160]; char* data; size_t size; } memory_file;
typedef struct memory_disk { memory_file files[64]; int count; const char* unreadable; } memory_disk;

static memory_file* disk_find(memory_disk* disk, const char* path) {
    for (int i = 0; i < disk->count; i++)
        if (strcmp(disk->files[i].path, path) == 0) return &disk->files[i];
    return NULL;
}
static gsf_result disk_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    memory_disk* disk = (memory_disk*)user;
    memory_file* file = disk_find(disk, path);
    (void)ctx;
    if (!file) {
        file = &disk->files[disk->count++];
        snprintf(file->path, sizeof file->path, "%s", path);
        file->data = NULL;
    }
    free(file->data);
    file->data = (char*)malloc(size + 1);
    memcpy(file->data, data, size);
    file->size = size;
    return GSF_OK;
}
static gsf_result disk_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    const memory_disk* disk = (const memory_disk*)user;
    const memory_file* file = disk_find((memory_disk*)user, path);
    if (disk->unreadable && strcmp(disk->unreadable, path) == 0) return gsf_fail(ctx, GSF_ERROR_IO, "%s: a bad sector", path);
    if (!file) return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: no such file", path);
    *data = gsf_alloc(ctx, file->size + 1, 1);
    if (!*data) return GSF_ERROR_OUT_OF_MEMORY;
    memcpy(*data, file->data, file->size);
    *size = file->size;
    return GSF_OK;
}
static void disk_put(memory_disk* disk, const char* path, const char* text) {
    (void)disk_write(disk, NULL, path, text, strlen(text));
}
static void disk_put_photo(memory_disk* disk, const char* path, int width, int height, int seed) { // a smooth PNG
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_image image;
    gsf_buffer png;
    memset(&png, 0, sizeof png);
    CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_U8, width, height, 3, &image));
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++)
            for (int c = 0; c < 3; c++)
                ((uint8_t*)image.data)[3 * (y * width + x) + c] =
                    (uint8_t)(128 + 100 * sin(seed + c + 6.0 * x / width) * cos(4.0 * y / height));
    CHECK_OK(&ctx, gsf_encode_image(&ctx, &image, ".png", &png));
    (void)disk_write(disk, &ctx, path, png.data, png.size);
    gsf_destroy_buffer(&ctx, &png);
    gsf_destroy_image(&ctx, &image);
    CHECK(count.live == 0);
}
static void disk_free(memory_disk* disk) {
    for (int i = 0; i < disk->count; i++) free(disk->files[i].data);
    disk->count = 0;
}
static gsf_context make_disk_context(counter* c, memory_disk* disk) {
    gsf_context ctx = make_counted_context(c);
    ctx.io.read_fn = disk_read;
    ctx.io.write_fn = disk_write;
    ctx.io.user = disk;
    return ctx;
}

// ---- COLMAP --------------------------------------------------------------------

typedef struct model_files { char* data[3]; size_t size[3]; } model_files;

static model_files read_model_at(const char* folder, const char* extension) { // a missing points3D stays NULL
    static const char* const names[3] = {"cameras", "images", "points3D"};
    model_files m;
    memset(&m, 0, sizeof m);
    for (int i = 0; i < 3; i++) {
        char path[1200];
        snprintf(path, sizeof path, "%s/%s.%s", folder, names[i], extension);
        FILE* file = fopen(path, "rb");
        if (!file) continue;
        fclose(file);
        char* data = test_read_file(path, &m.size[i]);
        m.data[i] = exact_copy(data, m.size[i]);
        free(data);
    }
    return m;
}
static model_files read_model(const char* folder, const char* extension) {
    return read_model_at(test_golden(folder), extension);
}
static void free_model(model_files* m) { for (int i = 0; i < 3; i++) free(m->data[i]); }

static gsf_result parse_model(gsf_context* ctx, int32_t is_text, const model_files* m, gsf_scene* out) {
    gsf_bytes bytes[3];
    for (int i = 0; i < 3; i++) bytes[i].data = m->data[i], bytes[i].size = m->size[i], bytes[i].name = NULL;
    return gsf_splat_parse_colmap(ctx, is_text, &bytes[0], &bytes[1], m->data[2] ? &bytes[2] : NULL, out);
}

static void test_colmap_golden(int32_t is_text) {
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene;
    model_files files = read_model(is_text ? "splat/colmap/txt" : "splat/colmap/bin", is_text ? "txt" : "bin");
    if (!CHECK_OK(&ctx, parse_model(&ctx, is_text, &files, &scene))) return;
    CHECK(warnings == 0);
    test_tensors t = test_open_tensors(test_golden("splat/colmap/expected.safetensors"));
    test_tensor order = test_get_tensor(&t, "name_sort_order"), c2w = test_get_tensor(&t, "c2w_sorted");
    test_tensor ids = test_get_tensor(&t, "image_ids"), camera_ids = test_get_tensor(&t, "image_camera_ids");
    test_tensor k1 = test_get_tensor(&t, "cam1_K"), k3 = test_get_tensor(&t, "cam3_K_undist");
    test_tensor roi = test_get_tensor(&t, "cam3_roi_xywh"), xyz = test_get_tensor(&t, "points_xyz");
    test_tensor rgb = test_get_tensor(&t, "points_rgb"), point_ids = test_get_tensor(&t, "points_ids");
    test_tensor tracks = test_get_tensor(&t, "tracks_pid_imgid_p2d");
    CHECK(scene.view_count == order.count && scene.point_count == point_ids.count);
    double mean[3] = {0, 0, 0};
    for (size_t i = 0; i < scene.view_count && i < order.count; i++) {
        const gsf_scene_view* view = &scene.views[i];
        const size_t file_index = (size_t)order.v[i];
        double pose[16], rows[16];
        CHECK(view->image_id == (uint32_t)ids.v[file_index]);
        CHECK(i == 0 || strcmp(scene.views[i - 1].name, view->name) < 0);
        gsf_get_camera_c2w(&view->camera, pose);
        for (int k = 0; k < 16; k++) rows[k] = pose[4 * (k % 4) + k / 4];
        test_compare("c2w", rows, c2w.v + 16 * i, 16, 1e-12);
        for (int k = 0; k < 3; k++) mean[k] += pose[12 + k] / (double)order.count;
        const double* expected = camera_ids.v[file_index] == 1 ? k1.v : k3.v;
        const double tolerance = camera_ids.v[file_index] == 1 ? 0 : 1e-6;
        const double k[9] = {view->camera.fx, 0, view->camera.cx, 0, view->camera.fy, view->camera.cy, 0, 0, 1};
        test_compare("K", k, expected, 9, tolerance);
        if (camera_ids.v[file_index] != 1)
            CHECK(roi.v[0] == 0 && roi.v[1] == 0 && view->camera.width == roi.v[2] && view->camera.height == roi.v[3]);
    }
    test_compare("origin", scene.origin, mean, 3, 1e-12);
    for (size_t p = 0; p < scene.point_count && p < point_ids.count; p++) {
        CHECK(scene.point_ids[p] == (uint64_t)point_ids.v[p]);
        test_compare("point", scene.points + 3 * p, xyz.v + 3 * p, 3, 0);
        for (int k = 0; k < 3; k++) CHECK(scene.colors[3 * p + k] == rgb.v[3 * p + k]);
        size_t expected = 0; // distinct views of the point
        for (size_t v = 0; v < scene.view_count; v++) {
            int seen = 0;
            for (size_t e = 0; e < tracks.dim[0]; e++)
                seen |= tracks.v[3 * e] == point_ids.v[p] && tracks.v[3 * e + 1] == scene.views[v].image_id;
            expected += (size_t)seen;
            int listed = 0;
            for (size_t e = scene.track_begin[p]; e < scene.track_begin[p + 1]; e++)
                listed += scene.track_views[e] == v;
            CHECK(listed == seen);
        }
        CHECK(scene.track_begin[p + 1] - scene.track_begin[p] == expected);
        for (size_t e = scene.track_begin[p] + 1; e < scene.track_begin[p + 1]; e++)
            CHECK(scene.track_views[e - 1] < scene.track_views[e]);
    }
    test_tensor* all[] = {&order, &c2w, &ids, &camera_ids, &k1, &k3, &roi, &xyz, &rgb, &point_ids, &tracks};
    for (size_t i = 0; i < sizeof all / sizeof all[0]; i++) test_free_tensor(all[i]);
    test_close_tensors(&t);
    gsf_splat_destroy_scene(&ctx, &scene);
    free_model(&files);
    CHECK(count.live == 0);
}

// The golden SIMPLE_RADIAL camera: OpenCV's maps and its remapped, cropped image.
static void test_undistort_golden(void) {
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene;
    model_files files = read_model("splat/colmap/bin", "bin");
    if (!CHECK_OK(&ctx, parse_model(&ctx, 0, &files, &scene))) return;
    test_tensors t = test_open_tensors(test_golden("splat/colmap/expected.safetensors"));
    test_tensor mapx = test_get_tensor(&t, "cam3_mapx"), mapy = test_get_tensor(&t, "cam3_mapy");
    test_tensor photo = test_get_tensor(&t, "cam3_image"), cropped = test_get_tensor(&t, "cam3_image_undist_cropped");
    test_tensor image_ids = test_get_tensor(&t, "image_ids"), camera_ids = test_get_tensor(&t, "image_camera_ids");
    const int64_t h = (int64_t)photo.dim[0], w = (int64_t)photo.dim[1];
    uint8_t* pixels = (uint8_t*)malloc(photo.count);
    for (size_t i = 0; i < photo.count; i++) pixels[i] = (uint8_t)photo.v[i];
    const gsf_image image = gsf_wrap_image(pixels, GSF_U8, w, h, 3);
    int tested = 0;
    for (size_t v = 0; v < scene.view_count; v++) {
        double camera_id = 0;
        for (size_t i = 0; i < image_ids.count; i++)
            if (image_ids.v[i] == scene.views[v].image_id) camera_id = camera_ids.v[i];
        if (camera_id != 3) continue;
        const gsf__rectify* r = &((gsf__scene_state*)scene.state)->sources[v].rectify;
        double worst = 0.0;
        for (int64_t y = 0; y < h; y++)
            for (int64_t x = 0; x < w; x++) {
                double sx, sy;
                gsf__rectify_map(r, (double)x, (double)y, &sx, &sy);
                worst = fmax(worst, fmax(fabs(sx - mapx.v[y * w + x]), fabs(sy - mapy.v[y * w + x])));
            }
        CHECK_NEAR(worst, 0.0, 1e-3);
        if (!CHECK_OK(&ctx, gsf_splat_set_view_image(&ctx, &scene, v, &image))) break;
        const gsf_image* out = &scene.views[v].image;
        CHECK(out->width == (int64_t)cropped.dim[1] && out->height == (int64_t)cropped.dim[0] && out->channels == 3);
        worst = 0.0;
        if ((size_t)(out->width * out->height * 3) == cropped.count)
            for (size_t i = 0; i < cropped.count; i++)
                worst = fmax(worst, fabs(((uint8_t*)out->data)[i] - cropped.v[i]));
        CHECK_NEAR(worst, 0.0, 1.0);
        tested++;
    }
    CHECK(tested > 0);
    CHECK_RESULT(&ctx, gsf_splat_set_view_image(&ctx, &scene, scene.view_count, &image), GSF_ERROR_INVALID_ARGUMENT);
    test_tensor* all[] = {&mapx, &mapy, &photo, &cropped, &image_ids, &camera_ids};
    for (size_t i = 0; i < sizeof all / sizeof all[0]; i++) test_free_tensor(all[i]);
    free(pixels);
    test_close_tensors(&t);
    gsf_splat_destroy_scene(&ctx, &scene);
    free_model(&files);
    CHECK(count.live == 0);
}

static void test_colmap_bad(void) {
    static const struct { const char* name; gsf_result result; const char* says; } cases[] = {
        {"00_cameras_truncated", GSF_ERROR_FORMAT, "cameras.bin:"},
        {"01_images_truncated", GSF_ERROR_FORMAT, "images.bin:"},
        {"02_points_truncated", GSF_ERROR_FORMAT, "points3D.bin:"},
        {"03_camera_count_huge", GSF_ERROR_FORMAT, "cameras.bin:0: 1152921504606846976 cameras"},
        {"04_name_unterminated", GSF_ERROR_FORMAT, "images.bin:"},
        {"05_points2d_count_huge", GSF_ERROR_FORMAT, "images.bin:"},
        {"06_unknown_camera_model", GSF_ERROR_UNSUPPORTED, "camera model 77 (colmap image_undistorter"},
        {"07_image_refers_missing_camera", GSF_ERROR_FORMAT, "camera 9 does not exist"},
        {"08_nan_pose", GSF_ERROR_NUMERIC, "images.bin:8:"},
        {"09_track_len_huge", GSF_ERROR_FORMAT, "track entries"},
        {"10_track_bad_image_id", GSF_OK, NULL},
        {"11_zero_quaternion", GSF_ERROR_NUMERIC, "images.bin:8:"},
        {"12_negative_size", GSF_ERROR_FORMAT, "image size"},
        {"13_points_missing", GSF_OK, NULL},
    };
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene;
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        char folder[128];
        snprintf(folder, sizeof folder, "splat/bad/colmap/%s", cases[i].name);
        model_files files = read_model(folder, "bin");
        ctx.error[0] = 0;
        count.asked = 0;
        CHECK_RESULT(&ctx, parse_model(&ctx, 0, &files, &scene), cases[i].result);
        if (!CHECK(!cases[i].says || strstr(ctx.error, cases[i].says)))
            fprintf(stderr, "  %s: %s\n", cases[i].name, ctx.error);
        CHECK(count.asked < 1000000);
        if (i == 10) CHECK(warnings == 1 && strstr(warning, "1 track entries"));
        if (i == 13) CHECK(scene.point_count == 0 && scene.track_begin[0] == 0);
        gsf_splat_destroy_scene(&ctx, &scene);
        free_model(&files);
    }
    // in a folder, missing points are an error
    CHECK_RESULT(&ctx, gsf_splat_load_scene(&ctx, test_golden("splat/bad/colmap/13_points_missing"), NULL, &scene),
                 GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx.error, "points3D.bin") != NULL);
    CHECK_RESULT(&ctx, gsf_splat_load_scene(&ctx, "no/such/folder", NULL, &scene), GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx.error, "no/such/folder: no scene") != NULL);
    const gsf_scene_desc both = {2, 100, 0};
    CHECK_RESULT(&ctx, gsf_splat_load_scene(&ctx, "x", &both, &scene), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(count.live == 0);
}

// Every truncation of each file; then each byte replaced by a few others, the first 64 by all other values.
static void test_colmap_damage(int32_t is_text) {
    model_files files = read_model(is_text ? "splat/colmap/txt" : "splat/colmap/bin", is_text ? "txt" : "bin");
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene;
    for (int f = 0; f < 3; f++) {
        model_files cut = files;
        for (size_t size = 0; size < files.size[f]; size++) {
            cut.data[f] = exact_copy(files.data[f], size);
            cut.size[f] = size;
            const gsf_result r = parse_model(&ctx, is_text, &cut, &scene);
            if (!cut.data[f] && f == 2) CHECK(r == GSF_OK); // no file means no points
            else CHECK(is_text ? r == GSF_OK || is_reader_refusal(r) : r == GSF_ERROR_FORMAT);
            gsf_splat_destroy_scene(&ctx, &scene);
            free(cut.data[f]);
        }
        for (size_t at = 0; at < files.size[f]; at += is_text ? 3 : 1)
            for (int flip = 1; flip < 256; flip += at < 64 && !is_text ? 1 : 101) {
                const char was = files.data[f][at];
                files.data[f][at] = (char)(was ^ flip);
                count.asked = 0;
                const gsf_result r = parse_model(&ctx, is_text, &files, &scene);
                CHECK(r == GSF_OK || is_reader_refusal(r));
                CHECK(count.asked < 1000000);
                gsf_splat_destroy_scene(&ctx, &scene);
                files.data[f][at] = was;
            }
    }
    free_model(&files);
    CHECK(count.live == 0);
}

static void test_colmap_out_of_memory(int32_t is_text) {
    model_files files = read_model(is_text ? "splat/colmap/txt" : "splat/colmap/bin", is_text ? "txt" : "bin");
    for (size_t k = 1;; k++) {
        counter count;
        gsf_context ctx = make_counted_context(&count);
        gsf_scene scene;
        count.fail_at = k;
        const gsf_result r = parse_model(&ctx, is_text, &files, &scene);
        gsf_splat_destroy_scene(&ctx, &scene);
        CHECK(count.live == 0);
        if (r == GSF_OK || !CHECK(r == GSF_ERROR_OUT_OF_MEMORY)) {
            CHECK(k > 10);
            break;
        }
    }
    free_model(&files);
}

// Text oddities: comments, empty lines, names with spaces, a missing last line, malformed values.
static gsf_result parse_text(gsf_context* ctx, const char* cameras, const char* images, const char* points,
                             gsf_scene* out) {
    model_files m;
    m.data[0] = (char*)(size_t)cameras, m.data[1] = (char*)(size_t)images, m.data[2] = (char*)(size_t)points;
    for (int i = 0; i < 3; i++) m.size[i] = m.data[i] ? strlen(m.data[i]) : 0;
    return parse_model(ctx, 1, &m, out);
}
static void test_colmap_text(void) {
    static const char cameras[] = "# x\r\n\r\n7 SIMPLE_PINHOLE 40 30 35 20 15\r\n";
    static const char images[] = "# y\n4 2 0 0 0 1 2 3 7 b c.png\n\n  3 1 0 0 0 0 0 0 7 a.png  \n1 2 -1 3 4 9";
    static const struct { const char *cameras, *images, *points, *says; } bad[] = {
        {"7 SIMPLE_PINHOLE 40 30 35 20", images, NULL, "cameras.txt:1: expected a camera parameter"},
        {"7 SIMPLE_PINHOLE 40 30 35 20 15 1", images, NULL, "found more"},
        {"7 SIMPLE_PINHOLE 40 30 -35 20 15", images, NULL, "focal length"},
        {"7 FOV 40 30 35 35 20 15 3.2", images, NULL, "omega"},
        {"7 SIMPLE_PINHOLE 40 0 35 20 15", images, NULL, "image size"},
        {"7 SIMPLE_PINHOLE 40 30 nan 20 15", images, NULL, "not finite"},
        {"7 HOLE 40 30 35 20 15", images, NULL, "\"HOLE\" (colmap image_undistorter"},
        {"7 EUCM 40 30 35 35 20 15 1.01 1", images, NULL, "alpha is not in 0..1"},
        {"7 EUCM 40 30 35 35 20 15 0.5 0", images, NULL, "beta is not above 0"},
        {"7 EQUIRECTANGULAR 40 20 40 20", images, NULL, "EQUIRECTANGULAR photos are panoramas"},
        {"7 RAD_TAN_THIN_PRISM_FISHEYE 40 30 35 35 20 15 0 0 0 0 0 0 0 0 0 0 0", images, NULL, "expected a camera param"},
        {"7 PINHOLE 40 30 1 1 0 0\n7 PINHOLE 40 30 1 1 0 0", images, NULL, "camera 7 occurs twice"},
        {"", images, NULL, "no camera"},
        {cameras, "", NULL, "no image"},
        {cameras, "4 1 0 0 0 0 0 0 7 a\n\n4 1 0 0 0 0 0 0 7 b\n", NULL, "image id 4 occurs twice"},
        {cameras, "4 1 0 0 0 0 0 0 7 a\n\n5 1 0 0 0 0 0 0 7 a\n", NULL, "two images are named \"a\""},
        {cameras, "4 1 0 0 0 0 0 0 7 a\n5 1 0 0 0 0 0 0 7 b\n", NULL, "images.txt:2: 10 values"},
        {cameras, "4 1 0 0 0 0 0 0 7 ../a\n", NULL, "leads out"},
        {cameras, "4 1 0 0 0 0 0 0 7 /a\n", NULL, "leads out"},
        {cameras, "4 1 0 0 0 0 0 0 7 x\\..\\a\n", NULL, "leads out"},
        {cameras, "4 1 0 0 0 0 0 0 7 c:a\n", NULL, "leads out"},
        {cameras, "4 1 0 0 0 0 0 0 7\n", NULL, "empty or malformed name"},
        {cameras, "4 1 0 0 0 0 inf 0 7 a\n", NULL, "is not a rotation"},
        {cameras, "4 1 0 0 0 0 1,5 0 7 a\n", NULL, "expected a pose"},
        {cameras, images, "1 0 0 0 256 0 0 0", "points3D.txt:1: expected a colour"},
        {cameras, images, "1 0 0 0 25 0 0 0 4", "expected a 2D point index"},
        {cameras, images, "1 0 0 x 25 0 0 0", "expected a coordinate, got \"x\""},
        {"7 SIMPLE_RADIAL 40 30 35 20 15 -1e300", images, NULL, "leaves no image"},
        {"7 SIMPLE_DIVISION 40 30 35 20 15 1e300", images, NULL, "leaves no image"},
    };
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene;
    CHECK_OK(&ctx,
             parse_text(&ctx, cameras, images, "9 1 2 3 4 5 6 -1 4 0 3 0 4 1 88 2\n8 nan 0 0 0 0 0 0 4 0\n", &scene));
    CHECK(scene.view_count == 2 && strcmp(scene.views[0].name, "a.png") == 0 &&
          strcmp(scene.views[1].name, "b c.png") == 0);
    CHECK(scene.point_count == 1 && scene.track_begin[1] == 2 && scene.track_views[0] == 0 &&
          scene.track_views[1] == 1);
    CHECK(warnings == 2 && scene.views[0].camera.fx == 35 && scene.views[0].camera.width == 40);
    CHECK_RESULT(&ctx, gsf_splat_load_view_image(&ctx, &scene, 0), GSF_ERROR_INVALID_ARGUMENT);
    gsf_splat_destroy_scene(&ctx, &scene);
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        const gsf_result r = parse_text(&ctx, bad[i].cameras, bad[i].images, bad[i].points, &scene);
        if (!CHECK(is_reader_refusal(r) && strstr(ctx.error, bad[i].says)))
            fprintf(stderr, "  case %zu: %s (%s)\n", i, ctx.error, gsf_describe_result(r));
        gsf_splat_destroy_scene(&ctx, &scene);
    }
    CHECK(count.live == 0);
}

// ---- lenses --------------------------------------------------------------------

// COLMAP's formulas, written again from its sensor/models.h, with libm.
static int is_fisheye(int model) { return model == 5 || (model >= 8 && model <= 11) || model == 14 || model == 15; }
static int has_one_focal(int model) {
    return model == 0 || model == 2 || model == 3 || model == 8 || model == 9 || model == 12 || model == 14;
}
static void reference_distort(int model, const double* p, double u, double v, double* x, double* y) {
    const double r2 = u * u + v * v, r = sqrt(r2);
    double a = u, b = v, du = 0, dv = 0, t2 = r2;
    if (is_fisheye(model) && r > 0) a = u * atan(r) / r, b = v * atan(r) / r, t2 = a * a + b * b;
    const double t4 = t2 * t2, t6 = t4 * t2, t8 = t4 * t4;
    const int one = has_one_focal(model);
    const double* e = p + (one ? 3 : 4);
    double radial = 0;
    switch (model) {
        case 2: case 8: radial = e[0] * t2; break;
        case 3: case 9: radial = e[0] * t2 + e[1] * t4; break;
        case 4: radial = e[0] * t2 + e[1] * t4; break;
        case 5: radial = e[0] * t2 + e[1] * t4 + e[2] * t6 + e[3] * t8; break;
        case 6: radial = (1 + e[0] * t2 + e[1] * t4 + e[4] * t6) / (1 + e[5] * t2 + e[6] * t4 + e[7] * t6) - 1; break;
        case 7: radial = r > 0 ? atan(r * 2 * tan(e[0] / 2)) / (r * e[0]) - 1 : 2 * tan(e[0] / 2) / e[0] - 1; break;
        case 10: radial = e[0] * t2 + e[1] * t4 + e[4] * t6 + e[5] * t8; break;
        case 11: for (int i = 0; i < 6; i++) radial += e[i] * pow(t2, i + 1); break;
        case 12: case 13: radial = 2 / (1 + sqrt(1 - 4 * e[0] * r2)) - 1; break;
        case 16: radial = 1 / (e[0] * sqrt(e[1] * r2 + 1) + 1 - e[0]) - 1; break;
        default: break;
    }
    if (model == 4 || model == 6 || model == 10) {
        du = 2 * e[2] * a * b + e[3] * (t2 + 2 * a * a);
        dv = 2 * e[3] * a * b + e[2] * (t2 + 2 * b * b);
    }
    if (model == 10) du += e[6] * t2, dv += e[7] * t2;
    if (model == 11) {
        const double q = (1 + radial) * a, w = (1 + radial) * b, q2 = q * q + w * w;
        du = 2 * e[7] * q * w + e[6] * (q2 + 2 * q * q) + e[8] * q2 + e[9] * q2 * q2;
        dv = 2 * e[6] * q * w + e[7] * (q2 + 2 * w * w) + e[10] * q2 + e[11] * q2 * q2;
    }
    *x = p[0] * (a + a * radial + du) + p[one ? 1 : 2];
    *y = p[one ? 0 : 1] * (b + b * radial + dv) + p[one ? 2 : 3];
}

static void test_lenses(void) {
    static const double params[17][16] = {{90, 51, 37},
                                          {90, 95, 51, 37},
                                          {90, 51, 37, -0.12},
                                          {90, 51, 37, -0.1, 0.02},
                                          {90, 95, 51, 37, -0.1, 0.02, 1e-3, -2e-3},
                                          {60, 62, 51, 37, 0.02, -0.01, 0.004, -0.001},
                                          {90, 95, 51, 37, 0.1, 0.02, 1e-3, -2e-3, 0.01, 0.2, 0.03, 0.002},
                                          {60, 62, 51, 37, 0.9},
                                          {60, 51, 37, 0.03},
                                          {60, 51, 37, 0.03, -0.01},
                                          {60, 62, 51, 37, 0.02, -0.01, 1e-3, -2e-3, 0.004, -0.001, 2e-3, -1e-3},
                                          {60, 62, 51, 37, 0.03, -0.02, 0.006, -0.002, 1e-3, -4e-4, 2e-3, -3e-3, 4e-3,
                                           -5e-3, 6e-3, -7e-3},
                                          {80, 51, 37, -0.25},
                                          {90, 95, 51, 37, 0.15},
                                          {60, 51, 37},
                                          {60, 62, 51, 37},
                                          {60, 62, 51, 37, 0.6, 1.2}};
    counter count;
    gsf_context ctx = make_counted_context(&count);
    for (int model = 0; model < 17; model++) {
        gsf__sfm m;
        gsf__rectify r;
        memset(&m, 0, sizeof m);
        CHECK_OK(&ctx, gsf__sfm_add_camera(&ctx, &m, "test", 0, 1, model, 100, 72, params[model]));
        if (!CHECK(m.camera_count == 1 && gsf__rectify_make(&m.cameras[0].lens, &r))) continue;
        double least = 1e9, worst = 0.0;
        for (int32_t j = 0; j < r.height; j++)
            for (int32_t i = 0; i < r.width; i++) {
                double x, y, ex, ey;
                gsf__rectify_map(&r, i, j, &x, &y);
                reference_distort(model, params[model], (i + r.centre - r.cx) / r.fx, (j + r.centre - r.cy) / r.fy, &ex,
                                  &ey);
                worst = fmax(worst, fmax(fabs(x + r.centre - ex), fabs(y + r.centre - ey)));
                least = fmin(least, fmin(fmin(x, y), fmin(99 - x, 71 - y)));
            }
        CHECK_NEAR(worst, 0.0, 1e-9);
        // no pixel comes from outside the photo, and the image reaches the photo's border (with OpenCV's five
        // iterations: almost)
        if (!CHECK(least > (r.lens.kind == GSF__LENS_RATIONAL ? -0.5 : -0.01) && least < 0.5))
            fprintf(stderr, "  model %d: distance to the photo's border %g\n", model, least);
        if (model < 2) CHECK(r.fx == params[model][0] && r.width == 100);
        gsf_free(&ctx, m.cameras);
    }
    for (double t = 0; t < 20; t += 0.0137) CHECK_NEAR(gsf__atan_ratio(t), t > 0 ? atan(t) / t : 1.0, 1e-12);
    CHECK(count.live == 0);
}

// Always the committed copy, since other golden folders (GSF_GOLDEN) may lack these files.
#ifdef TEST_GOLDEN
#define LENSES TEST_GOLDEN "/lenses"
#else
#define LENSES "tests/golden/lenses"
#endif

// Models written by COLMAP itself, with a camera of every kind, two per rig. Each observation in images.bin is where
// COLMAP projects the point. The points come from COLMAP's inverse distortion, so both directions must give the same
// pixel.
static void test_colmap_lenses(const char* folder, size_t camera_count) {
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene;
    model_files files = read_model_at(folder, "bin");
    if (!CHECK(files.data[2] != NULL) || !CHECK_OK(&ctx, parse_model(&ctx, 0, &files, &scene))) return;
    CHECK(scene.view_count == camera_count && scene.point_count == 9 * camera_count && warnings == 0);
    size_t at = 8, compared = 0;
    for (size_t n = 0; n < gsf__load_le(files.data[1], 8); n++) {
        const uint64_t id = gsf__load_le(files.data[1] + at, 4);
        size_t v = 0;
        while (v + 1 < scene.view_count && scene.views[v].image_id != id) v++;
        const gsf_camera* camera = &scene.views[v].camera;
        const gsf__rectify* r = &((const gsf__scene_state*)scene.state)->sources[v].rectify;
        at += 64 + strlen(files.data[1] + at + 64) + 1 + 8;
        for (int i = 0; i < 9; i++, at += 24, compared++) {
            const unsigned char* p = (const unsigned char*)files.data[1] + at;
            size_t point = 0;
            double u = 0, w = 0, depth = 0, x, y;
            while (point + 1 < scene.point_count && scene.point_ids[point] != gsf__load_le(p + 16, 8)) point++;
            CHECK(gsf_project_point(camera, scene.points + 3 * point, &u, &w, &depth));
            gsf__rectify_map(r, u - r->centre, w - r->centre, &x, &y);
            CHECK_NEAR(x + r->centre, gsf__load_f64(p), 1e-8);
            CHECK_NEAR(y + r->centre, gsf__load_f64(p + 8), 1e-8);
        }
    }
    CHECK(compared == 9 * camera_count);
    gsf_splat_destroy_scene(&ctx, &scene);
    free_model(&files);
    CHECK(count.live == 0);
}

// A camera model with two parameters, fewer than any other model has, must be refused as unsupported, not as damaged.
static void test_panorama(void) {
    char bytes[8 + 24 + 16] = {1};
    counter count;
    gsf_context ctx = make_counted_context(&count);
    model_files files = read_model("splat/colmap/bin", "bin");
    gsf_bytes cameras = {bytes, sizeof bytes, "cameras.bin"}, images = {files.data[1], files.size[1], NULL};
    gsf_scene scene;
    bytes[8] = 1, bytes[12] = 17, bytes[16] = 40, bytes[24] = 20;
    CHECK_RESULT(&ctx, gsf_splat_parse_colmap(&ctx, 0, &cameras, &images, NULL, &scene), GSF_ERROR_UNSUPPORTED);
    CHECK(strstr(ctx.error, "cameras.bin:8: camera 1: EQUIRECTANGULAR photos are panoramas") != NULL);
    free_model(&files);
    CHECK(count.live == 0);
}

// ---- folders -------------------------------------------------------------------

static void compare_scenes(const gsf_scene* a, const gsf_scene* b) {
    if (!CHECK(a->view_count == b->view_count && a->point_count == b->point_count)) return;
    for (size_t v = 0; v < a->view_count; v++) {
        const gsf_camera *x = &a->views[v].camera, *y = &b->views[v].camera;
        CHECK(strcmp(a->views[v].name, b->views[v].name) == 0 && a->views[v].image_id == b->views[v].image_id);
        CHECK(x->fx == y->fx && x->fy == y->fy && x->cx == y->cx && x->cy == y->cy);
        CHECK(x->width == y->width && x->height == y->height);
        test_compare("w2c", x->w2c, y->w2c, 16, 1e-14);
    }
    CHECK(memcmp(a->points, b->points, 24 * a->point_count) == 0 &&
          memcmp(a->colors, b->colors, 3 * a->point_count) == 0);
    CHECK(memcmp(a->point_ids, b->point_ids, 8 * a->point_count) == 0);
    CHECK(memcmp(a->track_begin, b->track_begin, sizeof(size_t) * (a->point_count + 1)) == 0);
    CHECK(memcmp(a->track_views, b->track_views, 4 * a->track_begin[a->point_count]) == 0);
}

// A folder as COLMAP writes it, with rigs and frames beside the model; once binary, once text.
static void test_rigs(void) {
    static const char* const names[5] = {"rigs", "cameras", "frames", "images", "points3D"};
    static memory_disk disk;
    gsf_scene scenes[2];
    counter count;
    gsf_context ctx = make_disk_context(&count, &disk);
    for (int32_t is_text = 0; is_text < 2; is_text++) {
        const char* extension = is_text ? "txt" : "bin";
        char from[1000], to[160];
        for (int i = 0; i < 5; i++) {
            size_t size;
            snprintf(from, sizeof from, LENSES "/%s-4.2.1/%s.%s", extension, names[i], extension);
            snprintf(to, sizeof to, "scene/sparse/0/%s.%s", names[i], extension);
            char* data = test_read_file(from, &size);
            (void)disk_write(&disk, NULL, to, data, size);
            free(data);
        }
        for (int model = 0; model < 17; model++) {
            snprintf(to, sizeof to, "scene/images/rig%d/%s.png", model / 2 + 1, gsf__lens_models[model].name);
            disk_put_photo(&disk, to, 100, 72, model);
        }
        warnings = 0;
        CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, "scene", NULL, &scenes[is_text]));
        CHECK(scenes[is_text].view_count == 17 && warnings == 0);
        for (size_t v = 0; v < scenes[is_text].view_count; v++)
            CHECK_OK(&ctx, gsf_splat_load_view_image(&ctx, &scenes[is_text], v));
        disk_free(&disk);
    }
    compare_scenes(&scenes[0], &scenes[1]);
    gsf_splat_destroy_scene(&ctx, &scenes[0]);
    gsf_splat_destroy_scene(&ctx, &scenes[1]);
    CHECK(count.live == 0);
}

static void test_save_load(void) {
    static memory_disk disk;
    counter count;
    gsf_context ctx = make_disk_context(&count, &disk);
    gsf_scene scene, again;
    model_files files = read_model("splat/colmap/bin", "bin");
    if (!CHECK_OK(&ctx, parse_model(&ctx, 0, &files, &scene))) return;
    CHECK_OK(&ctx, gsf_splat_save_colmap(&ctx, &scene, NULL, "out"));
    for (size_t v = 0; v < scene.view_count; v++) {
        char path[200];
        snprintf(path, sizeof path, "out/images/%s", scene.views[v].name);
        disk_put_photo(&disk, path, scene.views[v].camera.width, scene.views[v].camera.height, (int)v);
    }
    warnings = 0;
    if (CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, "out", NULL, &again))) {
        compare_scenes(&scene, &again);
        CHECK(strcmp(again.folder, "out") == 0 && warnings == 0);
        gsf_splat_destroy_scene(&ctx, &again);
    }
    // without some of the points: 2D points and track indices in the files must still refer to each other
    uint8_t* keep = (uint8_t*)calloc(scene.point_count, 1);
    for (size_t p = 0; p < scene.point_count; p += 2) keep[p] = 1;
    CHECK_OK(&ctx, gsf_splat_save_colmap(&ctx, &scene, keep, "out"));
    const memory_file* points = disk_find(&disk, "out/sparse/0/points3D.bin");
    const memory_file* images = disk_find(&disk, "out/sparse/0/images.bin");
    CHECK(gsf__load_le(points->data, 8) == (scene.point_count + 1) / 2);
    for (size_t at = 8; at < points->size;) {
        const uint64_t id = gsf__load_le(points->data + at, 8), track = gsf__load_le(points->data + at + 43, 8);
        at += 51;
        for (uint64_t e = 0; e < track; e++, at += 8) {
            const uint64_t image = gsf__load_le(points->data + at, 4), index = gsf__load_le(points->data + at + 4, 4);
            size_t i = 8;
            while (gsf__load_le(images->data + i, 4) != image) {
                i += 64 + strlen(images->data + i + 64) + 1;
                i += 8 + 24 * (size_t)gsf__load_le(images->data + i, 8);
            }
            i += 64 + strlen(images->data + i + 64) + 1;
            CHECK(index < gsf__load_le(images->data + i, 8) &&
                  gsf__load_le(images->data + i + 8 + 24 * index + 16, 8) == id);
        }
    }
    for (size_t k = 1;; k++) { // failing allocations while a folder is written and read
        counter inner;
        gsf_context small = make_disk_context(&inner, &disk);
        inner.fail_at = k;
        gsf_result r = gsf_splat_save_colmap(&small, &scene, NULL, "out");
        if (r == GSF_OK) r = gsf_splat_load_scene(&small, "out/", NULL, &again);
        if (r == GSF_OK) r = gsf_splat_load_view_image(&small, &again, 3);
        if (inner.live) gsf_splat_destroy_scene(&small, &again);
        CHECK(inner.live == 0);
        if (r == GSF_OK || !CHECK(r == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
    free(keep);
    gsf_splat_destroy_scene(&ctx, &scene);
    free_model(&files);
    disk_free(&disk);
    CHECK(count.live == 0);
}

static gsf_scene load_folder(gsf_context* ctx, const char* path, int factor, int max_size, gsf_result expected) {
    gsf_scene scene;
    gsf_scene_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.factor = factor;
    desc.max_size = max_size;
    CHECK_RESULT(ctx, gsf_splat_load_scene(ctx, path, &desc, &scene), expected);
    return scene;
}

// An object with a soft edge in front of a transparent green background, as RGBA. Size in pixels.
static void draw_object(int width, int height, uint8_t* rgba) {
    static const uint8_t object[3] = {200, 60, 120};
    for (int i = 0; i < width * height; i++) {
        const double x = (i % width + 0.5) / width - 0.5, y = (i / width + 0.5) / height - 0.5;
        const double cover = (0.3 - sqrt(x * x + y * y)) * width / 3.0 + 0.5;
        rgba[4 * i + 3] = (uint8_t)(255.0 * (cover > 0.0 ? cover < 1.0 ? cover : 1.0 : 0.0) + 0.5);
        for (int k = 0; k < 3; k++) rgba[4 * i + k] = rgba[4 * i + 3] ? object[k] : (uint8_t)(k == 1 ? 255 : 0);
    }
}

// Every pixel with weight shows the object (colours of small weight are coarse); a share of `share` has full weight,
// and some pixels have partial weight.
static void check_object(const gsf_scene_view* view, double share, double tolerance) {
    const uint8_t *c = (const uint8_t*)view->image.data, *w = (const uint8_t*)view->weight.data;
    const size_t pixels = (size_t)(view->camera.width * view->camera.height);
    size_t full = 0, part = 0;
    int wrong = 0;
    if (!CHECK(c && w && view->weight.width == view->camera.width && view->weight.height == view->camera.height &&
               view->weight.channels == 1 && view->weight.dtype == GSF_U8)) return;
    for (size_t i = 0; i < pixels; i++) {
        const int most = w[i] ? 2 + 256 / w[i] : 0;
        full += w[i] == 255;
        part += w[i] > 0 && w[i] < 255;
        if (w[i]) wrong += abs(c[3 * i] - 200) > most || abs(c[3 * i + 1] - 60) > most || abs(c[3 * i + 2] - 120) > most;
    }
    CHECK(wrong == 0 && part > 0);
    CHECK_NEAR((double)full / (double)pixels, share, tolerance);
}

static void test_photo_alpha(void) {
    static const char* const models[3] = {"1 PINHOLE 60 40 50 50 30 20\n", "1 PINHOLE 30 20 25 25 15 10\n",
                                          "1 OPENCV 30 20 25 25 15 10 -0.2 0.05 0.001 0.002\n"};
    static uint8_t rgba[4 * 60 * 40], grey[2 * 60 * 40], rgb[3 * 60 * 40];
    counter count;
    gsf_context ctx = make_counted_context(&count);
    draw_object(60, 40, rgba);
    for (int i = 0; i < 60 * 40; i++) {
        grey[2 * i] = rgba[4 * i];
        grey[2 * i + 1] = rgba[4 * i + 3];
        memcpy(rgb + 3 * i, rgba + 4 * i, 3);
    }
    for (int m = 0; m < 3; m++) {
        const char* images = "1 1 0 0 0 0 0 0 1 a.png\n\n";
        const gsf_bytes files[2] = {{models[m], strlen(models[m]), NULL}, {images, strlen(images), NULL}};
        gsf_scene scene;
        if (!CHECK_OK(&ctx, gsf_splat_parse_colmap(&ctx, 1, &files[0], &files[1], NULL, &scene))) return;
        gsf_scene_view* view = &scene.views[0];
        gsf_image photo = gsf_wrap_image(rgba, GSF_U8, 60, 40, 4);
        CHECK_OK(&ctx, gsf_splat_set_view_image(&ctx, &scene, 0, &photo));
        check_object(view, m < 2 ? 0.25 : 0.18, 0.06);
        if (m == 0) CHECK(((const uint8_t*)view->image.data)[1] == 255); // colours stay as they are stored
        photo = gsf_wrap_image(grey, GSF_U8, 60, 40, 2);
        CHECK_OK(&ctx, gsf_splat_set_view_image(&ctx, &scene, 0, &photo));
        CHECK(view->weight.data != NULL);
        // opaque: the same pixels as without alpha, and no weights
        const size_t bytes = 3 * (size_t)(view->camera.width * view->camera.height);
        uint8_t* kept = (uint8_t*)malloc(bytes);
        photo = gsf_wrap_image(rgb, GSF_U8, 60, 40, 3);
        CHECK_OK(&ctx, gsf_splat_set_view_image(&ctx, &scene, 0, &photo));
        CHECK(view->weight.data == NULL);
        memcpy(kept, view->image.data, bytes);
        uint8_t* opaque = (uint8_t*)malloc(sizeof rgba);
        memcpy(opaque, rgba, sizeof rgba);
        for (int i = 0; i < 60 * 40; i++) opaque[4 * i + 3] = 255;
        photo = gsf_wrap_image(opaque, GSF_U8, 60, 40, 4);
        CHECK_OK(&ctx, gsf_splat_set_view_image(&ctx, &scene, 0, &photo));
        CHECK(view->weight.data == NULL && memcmp(kept, view->image.data, bytes) == 0);
        if (m == 0) { // linear floats are encoded as sRGB: the same photo; alpha is linear in both
            float* linear = (float*)malloc(4 * 60 * 40 * sizeof *linear);
            for (int i = 0; i < 4 * 60 * 40; i++) {
                const double v = opaque[i] / 255.0;
                linear[i] = (float)(i % 4 == 3 ? v : v <= 0.04045 ? v / 12.92 : pow((v + 0.055) / 1.055, 2.4));
            }
            gsf_image encoded = gsf_wrap_image(linear, GSF_F32, 60, 40, 4);
            encoded.color_space = GSF_COLOR_LINEAR;
            CHECK_OK(&ctx, gsf_splat_set_view_image(&ctx, &scene, 0, &encoded));
            CHECK(view->weight.data == NULL && memcmp(kept, view->image.data, bytes) == 0);
            free(linear);
        }
        photo.channels = 5;
        CHECK_RESULT(&ctx, gsf_splat_set_view_image(&ctx, &scene, 0, &photo), GSF_ERROR_INVALID_ARGUMENT);
        CHECK(memcmp(kept, view->image.data, bytes) == 0);
        free(kept);
        free(opaque);
        gsf_splat_destroy_scene(&ctx, &scene);
        CHECK(count.live == 0);
    }
}

static void check_view(gsf_context* ctx, gsf_scene* scene, size_t v, int width, int height, double fx, double cx,
                       double cy) {
    if (!CHECK(v < scene->view_count)) return;
    const gsf_camera* c = &scene->views[v].camera;
    CHECK(c->width == width && c->height == height);
    CHECK_NEAR(c->fx, fx, 1e-12);
    CHECK_NEAR(c->cx, cx, 1e-12);
    CHECK_NEAR(c->cy, cy, 1e-12);
    if (CHECK_OK(ctx, gsf_splat_load_view_image(ctx, scene, v)))
        CHECK(scene->views[v].image.width == width && scene->views[v].image.height == height &&
              scene->views[v].image.channels == 3 && scene->views[v].image.dtype == GSF_U8);
}

#ifdef __linux__
static void save_picture(gsf_context* ctx, const char* folder, const char* name, void* pixels, int width, int height,
                         int channels) {
    char path[1000];
    const gsf_image image = gsf_wrap_image(pixels, GSF_U8, width, height, channels);
    snprintf(path, sizeof path, "%s/%s", folder, name);
    CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
}
#endif

// masks/a.png (twice the photo's size) and masks/b.jpg.png, as COLMAP names it; c.png has alpha and a mask, d.png no
// mask. A mask with another aspect ratio and a file that is not an image are errors that name the file.
static void test_photo_masks(void) {
#ifdef __linux__
    static uint8_t rgba[4 * 60 * 40], rgb[3 * 60 * 40], half[60 * 40], large[120 * 80];
    counter count;
    gsf_context ctx = make_counted_context(&count);
    char folder[500], path[4000];
    snprintf(folder, sizeof folder, "%s", test_scratch("masks"));
    snprintf(path, sizeof path, "rm -rf '%s' && mkdir -p '%s/sparse' '%s/images' '%s/masks'", folder, folder, folder, folder);
    CHECK(system(path) == 0);
    static const char* const texts[3][2] = {
        {"sparse/cameras.txt", "1 PINHOLE 60 40 50 50 30 20\n"},
        {"sparse/images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 1 b.jpg\n\n3 1 0 0 0 1 0 0 1 c.png\n\n"
                              "4 1 0 0 0 1 0 0 1 d.png\n\n"},
        {"sparse/points3D.txt", "3 0 0 5 1 2 3 0 1 0 2 0\n"}};
    for (int i = 0; i < 3; i++) {
        snprintf(path, sizeof path, "%s/%s", folder, texts[i][0]);
        CHECK_OK(&ctx, gsf_write_file(&ctx, path, texts[i][1], strlen(texts[i][1])));
    }
    draw_object(60, 40, rgba);
    for (int i = 0; i < 60 * 40; i++) {
        memcpy(rgb + 3 * i, rgba + 4 * i, 3);
        half[i] = i % 60 < 30 ? 255 : 0;
    }
    for (int i = 0; i < 120 * 80; i++) large[i] = i % 120 < 60 ? 255 : 0;
    save_picture(&ctx, folder, "images/a.png", rgb, 60, 40, 3);
    save_picture(&ctx, folder, "images/b.jpg", rgb, 60, 40, 3);
    save_picture(&ctx, folder, "images/c.png", rgba, 60, 40, 4);
    save_picture(&ctx, folder, "images/d.png", rgb, 60, 40, 3);
    save_picture(&ctx, folder, "masks/a.png", large, 120, 80, 1);
    save_picture(&ctx, folder, "masks/b.jpg.png", half, 60, 40, 1);
    save_picture(&ctx, folder, "masks/c.png", half, 60, 40, 1);
    gsf_scene scene;
    for (int off = 0; off < 2; off++) {
        gsf_scene_desc desc = {0};
        desc.no_masks = off;
        if (!CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, folder, &desc, &scene))) return;
        for (size_t v = 0; v < 4; v++) {
            CHECK_OK(&ctx, gsf_splat_load_view_image(&ctx, &scene, v));
            const uint8_t* w = (const uint8_t*)scene.views[v].weight.data;
            CHECK((w != NULL) == (!off && v < 3));
            int wrong = 0;
            for (int i = 0; w && i < 60 * 40; i++) {
                const int wanted = half[i] ? v == 2 ? rgba[4 * i + 3] : 255 : 0;
                wrong += w[i] != wanted && !(v == 0 && (i % 60 == 29 || i % 60 == 30)); // downscaling softens the edge
            }
            CHECK(wrong == 0);
        }
        gsf_splat_destroy_scene(&ctx, &scene);
    }
    save_picture(&ctx, folder, "masks/d.png", half, 40, 60, 1);
    CHECK_OK(&ctx, gsf_splat_load_scene(&ctx, folder, NULL, &scene));
    CHECK_RESULT(&ctx, gsf_splat_load_view_image(&ctx, &scene, 3), GSF_ERROR_FORMAT);
    CHECK(strstr(ctx.error, "masks/d.png") != NULL && scene.views[3].image.data == NULL);
    snprintf(path, sizeof path, "%s/masks/d.png", folder);
    CHECK_OK(&ctx, gsf_write_file(&ctx, path, "none", 4));
    CHECK_RESULT(&ctx, gsf_splat_load_view_image(&ctx, &scene, 3), GSF_ERROR_FORMAT);
    snprintf(path, sizeof path, "cd '%s/masks' && rm d.png && mkdir d.png", folder);
    CHECK(system(path) == 0); // an unreadable mask is not a missing one
    CHECK_RESULT(&ctx, gsf_splat_load_view_image(&ctx, &scene, 3), GSF_ERROR_IO);
    gsf_splat_destroy_scene(&ctx, &scene);
    CHECK(count.live == 0);
#endif
}

// Only photos that do not exist count as missing. One that exists but cannot be read is an error, since leaving it out
// would change the views and the split.
static void test_unreadable_photos(void) {
#ifdef __linux__
    counter count;
    gsf_context ctx = make_counted_context(&count);
    char folder[500], path[2000];
    gsf_image image;
    snprintf(folder, sizeof folder, "%s", test_scratch("unreadable"));
    snprintf(path, sizeof path, "rm -rf '%s' && mkdir -p '%s/sparse' '%s/images'", folder, folder, folder);
    CHECK(system(path) == 0);
    static const char* const texts[3][2] = {
        {"cameras", "1 PINHOLE 8 6 5 5 4 3\n"},
        {"images", "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 1 b.png\n\n3 1 0 0 0 1 0 0 1 c.png\n\n"},
        {"points3D", "3 0 0 5 1 2 3 0 1 0 2 0\n"}};
    for (int i = 0; i < 3; i++) {
        snprintf(path, sizeof path, "%s/sparse/%s.txt", folder, texts[i][0]);
        CHECK_OK(&ctx, gsf_write_file(&ctx, path, texts[i][1], strlen(texts[i][1])));
    }
    CHECK_OK(&ctx, gsf_make_image(&ctx, GSF_U8, 8, 6, 3, &image));
    for (int i = 0; i < 2; i++) {
        snprintf(path, sizeof path, "%s/images/%c.png", folder, 'a' + i);
        CHECK_OK(&ctx, gsf_save_image(&ctx, path, &image));
    }
    gsf_destroy_image(&ctx, &image);
    snprintf(path, sizeof path, "%s/images/c.png", folder);
    gsf_scene scene = load_folder(&ctx, folder, 0, 0, GSF_OK);
    CHECK(scene.view_count == 2 && scene.missing_count == 1);
    gsf_splat_destroy_scene(&ctx, &scene);
    for (int way = 0; way < 3; way++) {
        if (way == 0) CHECK(mkfifo(path, 0600) == 0);
        if (way == 1) CHECK(mkdir(path, 0700) == 0);
        if (way == 2) CHECK(symlink("c.png", path) == 0);
        scene = load_folder(&ctx, folder, 0, 0, GSF_ERROR_IO);
        CHECK(strstr(ctx.error, path) && !scene.views);
        CHECK(remove(path) == 0);
    }
    // a file without read permission: root switches to another user; if it can still be read, nothing is tested
    CHECK_OK(&ctx, gsf_write_file(&ctx, path, "x", 1));
    CHECK(chmod(path, 0) == 0);
    const int root = geteuid() == 0;
    if (!root || seteuid(65534) == 0) {
        FILE* open = fopen(path, "rb");
        if (open) fclose(open);
        else if (errno == EACCES) {
            scene = load_folder(&ctx, folder, 0, 0, GSF_ERROR_IO);
            CHECK(strstr(ctx.error, "c.png") && strstr(ctx.error, "denied") && !scene.views);
        }
        CHECK(!root || seteuid(0) == 0);
    }
    CHECK(remove(path) == 0);
    CHECK(symlink("elsewhere.png", path) == 0); // a dangling link
    scene = load_folder(&ctx, folder, 0, 0, GSF_OK);
    CHECK(scene.missing_count == 1);
    gsf_splat_destroy_scene(&ctx, &scene);
    CHECK(count.live == 0);
#endif
}

static void test_image_folders(void) {
    static memory_disk disk;
    counter count;
    disk_put(&disk, "s/sparse/cameras.txt", "1 PINHOLE 41 30 35 36 20 15\n2 SIMPLE_RADIAL 40 30 35 20 15 0.05\n");
    disk_put(&disk, "s/sparse/images.txt",
             "5 1 0 0 0 0 0 0 1 sub/a.jpg\n\n2 1 0 0 0 1 0 0 1 b.png\n\n9 1 0 0 0 2 0 0 2 c.png\n\n1 1 0 0 0 2 0 0 2 "
             "d.png\n\n");
    disk_put(&disk, "s/sparse/points3D.txt", "3 0 0 5 1 2 3 0 1 0 9 0 5 0 2 0\n");
    disk_put_photo(&disk, "s/images/sub/a.jpg", 41, 30, 1);
    disk_put_photo(&disk, "s/images/b.png", 82, 60, 2); // larger than in COLMAP's model
    disk_put_photo(&disk, "s/images/c.png", 40, 30, 3);
    // downscaled photos with another extension; b and c have none
    disk_put_photo(&disk, "s/images_2/sub/a.png", 20, 15, 4);
    gsf_context ctx = make_disk_context(&count, &disk);
    gsf_scene scene = load_folder(&ctx, "s", 0, 0, GSF_OK);
    CHECK(scene.view_count == 3 && warnings == 1 && strstr(warning, "s/images/d.png")); // d.png is missing
    CHECK(scene.missing_count == 1);
    if (scene.view_count == 3) {
        CHECK(strcmp(scene.views[0].name, "b.png") == 0 && strcmp(scene.views[2].name, "sub/a.jpg") == 0);
        CHECK(scene.track_begin[1] == 3); // images 1 9 5 2 without 1
        check_view(&ctx, &scene, 0, 82, 60, 70, 40, 30);
        check_view(&ctx, &scene, 2, 41, 30, 35, 20, 15);
        CHECK(scene.views[1].camera.width == 39 && scene.views[1].camera.height == 29);
        CHECK_OK(&ctx, gsf_splat_load_view_image(&ctx, &scene, 1));
        CHECK(scene.views[1].image.width == 39 && scene.views[1].image.height == 29);
    }
    gsf_splat_destroy_scene(&ctx, &scene);
    scene = load_folder(&ctx, "s", 2, 0, GSF_OK);
    check_view(&ctx, &scene, 0, 41, 30, 35, 20, 15);                                   // 82 x 60 halved
    check_view(&ctx, &scene, 2, 20, 15, 35 * 20.0 / 41, 20 * 20.0 / 41, 7.5);          // read from images_2
    if (scene.view_count == 3) CHECK(scene.views[1].camera.width == 19 && scene.views[1].camera.height == 14);
    gsf_splat_destroy_scene(&ctx, &scene);
    scene = load_folder(&ctx, "s", 4, 0, GSF_OK);
    // 82 / 4 = 20.5: rounded half to even
    check_view(&ctx, &scene, 0, 20, 15, 35 * 20.0 / 41, 20 * 20.0 / 41, 7.5);
    check_view(&ctx, &scene, 2, 10, 8, 35 * 10.0 / 41, 20 * 10.0 / 41, 4);             // 30 / 4 = 7.5
    gsf_splat_destroy_scene(&ctx, &scene);
    scene = load_folder(&ctx, "s", 0, 41, GSF_OK);
    check_view(&ctx, &scene, 0, 41, 30, 35, 20, 15);
    check_view(&ctx, &scene, 2, 41, 30, 35, 20, 15); // not enlarged
    gsf_splat_destroy_scene(&ctx, &scene);
    // the same for the host's io hook: an unreadable file does not count as missing
    static const char* const unreadable[] = {"s/images/b.png", "s/sparse/points3D.txt", "s/sparse/0/cameras.bin"};
    for (int i = 0; i < 3; i++) {
        disk.unreadable = unreadable[i];
        scene = load_folder(&ctx, "s", 0, 0, GSF_ERROR_IO);
        CHECK(strstr(ctx.error, unreadable[i]) && scene.views == NULL && scene.missing_count == 0);
    }
    disk.unreadable = NULL;
    disk_put(&disk, "s/images/b.png", "no image at all");
    scene = load_folder(&ctx, "s", 0, 0, GSF_ERROR_FORMAT);
    CHECK(strstr(ctx.error, "s/images/b.png") != NULL);
    disk_put(&disk, "s/sparse/images.txt", "5 1 0 0 0 0 0 0 1 nothing.jpg\n");
    scene = load_folder(&ctx, "s", 0, 0, GSF_ERROR_NOT_FOUND);
    CHECK(strstr(ctx.error, "all 1 photos are missing") != NULL);
    disk_put(&disk, "s/sparse/images.txt", "5 1 0 0 0 0 0 0 1 x/../../b.png\n");
    scene = load_folder(&ctx, "s", 0, 0, GSF_ERROR_FORMAT);
    CHECK(strstr(ctx.error, "leads out of its folder") != NULL && scene.views == NULL);
    CHECK(count.live == 0);
    disk_free(&disk);
}

// ---- transforms.json -----------------------------------------------------------

#define POSE "\"transform_matrix\":[[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]"

static gsf_result parse_json_scene(gsf_context* ctx, const char* text, size_t size, gsf_scene* out) {
    gsf_bytes bytes;
    bytes.data = text;
    bytes.size = size;
    bytes.name = "t.json";
    return gsf_splat_parse_transforms(ctx, &bytes, out);
}

static const char nerfstudio[] =
    "{\"w\":40,\"h\":30,\"fl_x\":35.5,\"fl_y\":36.5,\"cx\":20.25,\"cy\":14.5,\"k1\":0,\"camera_model\":\"OPENCV\",\n"
    "\"applied_transform\":[[1,0,0,0],[0,0,1,0],[0,-1,0,0]],\"ply_file_path\":\"points.ply\",\"frames\":[\n"
    "{\"file_path\":\"./images/b.png\"," POSE "},\n"
    "{\"file_path\":\"images/a.png\",\"fl_x\":70,\"k1\":0.01,"
    "\"transform_matrix\":[[0,-1,0,5],[1,0,0,6],[0,0,1,7],[0,0,0,1]]}]}";

static void test_transforms(void) {
    static memory_disk disk;
    counter count;
    gsf_context ctx = make_disk_context(&count, &disk);
    gsf_scene scene;
    CHECK_OK(&ctx, parse_json_scene(&ctx, nerfstudio, sizeof nerfstudio - 1, &scene));
    if (CHECK(scene.view_count == 2 && scene.point_count == 0)) {
        const gsf_camera *a = &scene.views[0].camera, *b = &scene.views[1].camera;
        CHECK(strcmp(scene.views[0].name, "images/a.png") == 0 && strcmp(scene.views[1].name, "images/b.png") == 0);
        CHECK(b->fx == 35.5 && b->fy == 36.5 && b->cx == 20.25 && b->cy == 14.5 && b->width == 40 && b->height == 30);
        CHECK(a->width == 39 && fabs(a->fx / 70 - 1) < 0.05); // undistorted with its own lens parameters
        double centre[3], u, v, depth;
        gsf_get_camera_center(b, centre);
        CHECK(centre[0] == 1 && centre[1] == 2 && centre[2] == 3);
        const double ahead[3] = {1, 2, -7}, above[3] = {1, 4, -7}; // OpenGL: looks along -z, y is up
        CHECK(gsf_project_point(b, ahead, &u, &v, &depth) && depth == 10 && u == b->cx && v == b->cy);
        CHECK(gsf_project_point(b, above, &u, &v, &depth) && v < b->cy);
        gsf_get_camera_center(a, centre);
        CHECK_NEAR(centre[0] + 10 * centre[1] + 100 * centre[2], 765, 1e-12);
        CHECK_NEAR(scene.origin[0], 3, 1e-12);
    }
    gsf_splat_destroy_scene(&ctx, &scene);

    // from a folder, with points; instant-ngp's field of view needs the size of the photo
    disk_put(&disk, "n/transforms.json", nerfstudio);
    disk_put(&disk, "n/points.ply", "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
             "property float z\nproperty uchar red\nproperty uint8 green\nproperty uint8 blue\nend_header\n"
             "1 2 3 4 5 6\n-1 -2 -3 255 0 1\n");
    disk_put_photo(&disk, "n/images/a.png", 40, 30, 1);
    disk_put_photo(&disk, "n/images/b.png", 40, 30, 2);
    disk_put_photo(&disk, "n/images_2/b.png", 20, 15, 2);
    scene = load_folder(&ctx, "n", 0, 0, GSF_OK);
    CHECK(scene.point_count == 2 && scene.points[4] == -2 && scene.colors[2] == 6 && scene.colors[3] == 255);
    CHECK(scene.track_begin[2] == 0);
    check_view(&ctx, &scene, 1, 40, 30, 35.5, 20.25, 14.5);
    gsf_splat_destroy_scene(&ctx, &scene);
    scene = load_folder(&ctx, "n/transforms.json", 2, 0, GSF_OK);
    check_view(&ctx, &scene, 1, 20, 15, 17.75, 10.125, 7.25);
    gsf_splat_destroy_scene(&ctx, &scene);
    disk_put(&disk, "n/transforms.json", "{\"camera_angle_x\":1.5707963267948966,\"aabb_scale\":4,\"frames\":["
             "{\"file_path\":\"images/b\",\"sharpness\":2," POSE "}]}");
    scene = load_folder(&ctx, "n/", 0, 0, GSF_OK);
    check_view(&ctx, &scene, 0, 40, 30, 20, 20, 15);
    gsf_splat_destroy_scene(&ctx, &scene);
    scene = load_folder(&ctx, "n", 2, 0, GSF_OK);
    check_view(&ctx, &scene, 0, 20, 15, 10, 10, 7.5);
    gsf_splat_destroy_scene(&ctx, &scene);

    static const struct { const char *text, *says; } bad[] = {
        {"[]", "no \"frames\""},
        {"{\"frames\":{}}", "no \"frames\""},
        {"{\"frames\":[]}", "no image"},
        {"{\"frames\":[1]}", "a frame is not an object"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"frames\":[{" POSE "}]}", "without file_path"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"frames\":[{\"file_path\":\"a\"}]}", "transform_matrix"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"frames\":[{\"file_path\":\"a\",\"transform_matrix\":"
         "[[1,0,0,0],[0,1,0],[0,0,1,0]]}]}",
         "4x4 matrix of numbers"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"frames\":[{\"file_path\":\"a\",\"transform_matrix\":"
         "[[1,0,0,0],[0,1,0,0],[0,0,-1,0]]}]}",
         "is not a rotation"},
        {"{\"w\":4,\"h\":4,\"frames\":[{\"file_path\":\"a\"," POSE "}]}", "neither fl_x"},
        {"{\"fl_x\":1,\"frames\":[{\"file_path\":\"a\"," POSE "}]}", "no usable w, h"},
        {"{\"fl_x\":\"1\",\"frames\":[{\"file_path\":\"a\"," POSE "}]}", "\"fl_x\" is not a number"},
        {"{\"fl_x\":1,\"w\":-4,\"h\":4,\"frames\":[{\"file_path\":\"a\"," POSE "}]}", "image size"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"camera_model\":\"EQUIRECTANGULAR\",\"frames\":[{\"file_path\":\"a\"," POSE
         "}]}",
         "EQUIRECTANGULAR"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"frames\":[{\"file_path\":\"../a\"," POSE "}]}", "leads out"},
        {"{\"fl_x\":1,\"w\":4,\"h\":4,\"frames\":[{\"file_path\":\"a\\u0000b\"," POSE "}]}", "leads out"},
        {"{\"fl_x\":1,", "t.json"},
    };
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; i++) {
        const gsf_result r = parse_json_scene(&ctx, bad[i].text, strlen(bad[i].text), &scene);
        if (!CHECK(is_reader_refusal(r) && strstr(ctx.error, bad[i].says)))
            fprintf(stderr, "  case %zu: %s (%s)\n", i, ctx.error, gsf_describe_result(r));
    }
    disk_put(&disk, "n/transforms.json",
             "{\"fl_x\":9,\"ply_file_path\":\"../x.ply\",\"frames\":[{\"file_path\":\"images/b.png\"," POSE "}]}");
    scene = load_folder(&ctx, "n", 0, 0, GSF_ERROR_FORMAT);
    disk_put(&disk, "n/transforms.json",
             "{\"fl_x\":9,\"ply_file_path\":\"x.ply\",\"frames\":[{\"file_path\":\"images/b.png\"," POSE "}]}");
    scene = load_folder(&ctx, "n", 0, 0, GSF_ERROR_NOT_FOUND);
    for (size_t size = 0; size < sizeof nerfstudio - 1; size++) { // every truncation
        char* cut = (char*)exact_copy(nerfstudio, size);
        CHECK(parse_json_scene(&ctx, cut, size, &scene) == GSF_ERROR_FORMAT);
        free(cut);
    }
    char* whole = (char*)exact_copy(nerfstudio, sizeof nerfstudio - 1);
    for (size_t at = 0; at < sizeof nerfstudio - 1; at++)
        for (int flip = 1; flip < 256; flip += 7) {
            whole[at] = (char)(nerfstudio[at] ^ flip);
            const gsf_result r = parse_json_scene(&ctx, whole, sizeof nerfstudio - 1, &scene);
            CHECK(r == GSF_OK || is_reader_refusal(r));
            gsf_splat_destroy_scene(&ctx, &scene);
            whole[at] = nerfstudio[at];
        }
    free(whole);
    CHECK(count.live == 0);
    disk_put(&disk, "n/transforms.json", nerfstudio);
    for (size_t k = 1;; k++) {
        counter inner;
        gsf_context small = make_disk_context(&inner, &disk);
        inner.fail_at = k;
        const gsf_result r = gsf_splat_load_scene(&small, "n", NULL, &scene);
        gsf_splat_destroy_scene(&small, &scene);
        CHECK(inner.live == 0);
        if (r == GSF_OK || !CHECK(r == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
    disk_free(&disk);
}

// ---- split ---------------------------------------------------------------------

static void test_split(void) {
    counter count;
    gsf_context ctx = make_counted_context(&count);
    size_t size, tables = 0;
    char* text = test_read_file(test_golden("traj/tables.json"), &size);
    gsf_json json;
    if (!CHECK_OK(&ctx, gsf_parse_json(&ctx, "tables.json", text, size, &json))) return;
    const gsf_json_value* splits = gsf_find_json_member(&json, &json.values[0], "splits");
    for (uint32_t i = splits ? splits->child : 0; i; i = json.values[i].next, tables++) {
        const gsf_json_value* row = &json.values[i];
        const size_t n = (size_t)gsf_find_json_member(&json, row, "n")->number;
        const size_t every = (size_t)gsf_find_json_member(&json, row, "test_every")->number;
        const size_t k = (size_t)gsf_find_json_member(&json, row, "K")->number;
        const gsf_json_value *train = gsf_find_json_member(&json, row, "train"),
                             *ends = gsf_find_json_member(&json, row, "test_first_last");
        uint32_t* arrays = (uint32_t*)malloc(2 * (n + k) * sizeof(uint32_t));
        size_t train_count, test_count;
        gsf_splat_split_views(n, every, k, arrays, &train_count, arrays + n + k, &test_count);
        CHECK(train_count == gsf_find_json_member(&json, row, "n_train")->number);
        CHECK(test_count == gsf_find_json_member(&json, row, "n_test")->number);
        CHECK(arrays[n + k] == gsf_find_json_element(&json, ends, 0)->number);
        CHECK(arrays[n + k + test_count - 1] == gsf_find_json_element(&json, ends, 1)->number);
        if (train->type == GSF_JSON_ARRAY)
            for (size_t j = 0; j < train_count; j++) CHECK(arrays[j] == gsf_find_json_element(&json, train, j)->number);
        else
            for (size_t j = 0; j < train_count; j++) CHECK(arrays[j] % every != 0 && (!j || arrays[j - 1] < arrays[j]));
        free(arrays);
    }
    CHECK(tables > 0);
    size_t a = 9, b = 9;
    gsf_splat_split_views(0, 8, 3, NULL, &a, NULL, &b);
    CHECK(a == 0 && b == 0);
    gsf_splat_split_views(5, 1, 3, NULL, &a, NULL, &b);
    CHECK(a == 0 && b == 5);
    uint32_t one[5];
    gsf_splat_split_views(5, 0, 1, one, &a, NULL, &b);
    CHECK(a == 1 && b == 0 && one[0] == 0);
    gsf_destroy_json(&ctx, &json);
    free(text);
    CHECK(count.live == 0);
}

// ---- the fox photos ------------------------------------------------------------

static void check_split_list(const gsf_json* json, const char* key, const gsf_scene* scene, const uint32_t* views,
                             size_t n) {
    const gsf_json_value* list = gsf_find_json_member(json, &json->values[0], key);
    if (!CHECK(list && list->count == n)) return;
    for (size_t i = 0; i < n; i++)
        CHECK(strcmp(gsf_find_json_element(json, list, i)->string, scene->views[views[i]].name) == 0);
}

static void test_fox_photos(void) {
    char path[1100];
    const char* folder = test_fox();
    FILE* file = NULL;
    if (folder) {
        snprintf(path, sizeof path, "%s/split.json", folder);
        file = fopen(path, "rb");
    }
    if (!file) {
        printf("the fox photos are not here (GSF_FOX): skipped\n");
        return;
    }
    fclose(file);
    counter count;
    gsf_context ctx = make_counted_context(&count);
    gsf_scene scene = load_folder(&ctx, folder, 0, 0, GSF_OK);
    size_t size, n_train, n_test;
    char* text = test_read_file(path, &size);
    gsf_json json;
    if (!CHECK_OK(&ctx, gsf_parse_json(&ctx, path, text, size, &json))) return;
    if (CHECK(scene.view_count == 48 && scene.point_count == 10707 && warnings == 0)) {
        uint32_t train[48], test[48];
        gsf_splat_split_views(48, 8, 0, train, &n_train, test, &n_test);
        check_split_list(&json, "train_all", &scene, train, n_train);
        check_split_list(&json, "test", &scene, test, n_test);
        static const char* const keys[3] = {"train_3", "train_6", "train_9"};
        for (size_t k = 0; k < 3; k++) {
            gsf_splat_split_views(48, 8, 3 * (k + 1), train, &n_train, NULL, NULL);
            check_split_list(&json, keys[k], &scene, train, n_train);
        }
        size_t inside = 0, all = 0; // the points project to where the photos observe them
        for (size_t p = 0; p < scene.point_count; p++)
            for (size_t e = scene.track_begin[p]; e < scene.track_begin[p + 1]; e++, all++) {
                const gsf_camera* c = &scene.views[scene.track_views[e]].camera;
                double u, v, depth;
                inside += gsf_project_point(c, scene.points + 3 * p, &u, &v, &depth) && u > -5 && v > -5 &&
                          u < c->width + 5 && v < c->height + 5;
            }
        CHECK(all > 20000 && inside > all - all / 100);
        CHECK_OK(&ctx, gsf_splat_load_view_image(&ctx, &scene, 0));
        CHECK(scene.views[0].image.width == 264 && scene.views[0].image.height == 480);
    }
    free(text);
    gsf_destroy_json(&ctx, &json);
    gsf_splat_destroy_scene(&ctx, &scene);
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
    for (int32_t is_text = 0; is_text < 2; is_text++) {
        test_colmap_golden(is_text);
        test_colmap_damage(is_text);
        test_colmap_out_of_memory(is_text);
    }
    test_undistort_golden();
    test_colmap_bad();
    test_colmap_text();
    test_lenses();
    test_colmap_lenses(LENSES "/bin-3.12.6", 12);
    test_colmap_lenses(LENSES "/bin-4.2.1", 17);
    test_panorama();
    test_rigs();
    test_save_load();
    test_photo_alpha();
    test_photo_masks();
    test_unreadable_photos();
    test_image_folders();
    test_transforms();
    test_split();
    test_fox_photos();
    return test_report();
}
