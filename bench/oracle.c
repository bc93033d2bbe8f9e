// oracle.c - restorers that know the ground truth, for bench/headroom.py: how much the repair loop gains from which
// information
//
//     oracle cameras SCENE OUT.json [--max-size N | --factor N]     writes the cameras of the scene's views
//     oracle render SPLATS CAMERAS.json OUT [--near Z]              renders the truth from a model of all photos
//     oracle masks CAMERAS.json TRUTH PHOTOS.json PHOTO_TRUTH OUT   writes masks, white where a photo sees the surface
//     oracle restore ROW JOBDIR TRUTH PHOTO_TRUTH                   restores a window of gsfix fix --restorer exec:
//         [--tolerance T] [--far Z] [--sigma S]
//
// TRUTH contains the ground truth at each camera: images 00000.png ... and depth/00000.npy ..., camera depth at pixel centres,
// 0 where there is nothing. `oracle render` and `make_scene --render` write it. PHOTO_TRUTH is the same at the cameras of
// the photos; only its depth is read. ROW is one of
//
//     warp      the frames as the restorer warp returns them
//     carried   colours of the photos, carried over with the true depth and blended by angle as in warp; confidence 1
//               where a photo sees the surface
//     masked    the truth with warp's confidence
//     blurred   the truth, blurred by a Gaussian of --sigma pixels (default 2), confidence 1 everywhere
//     seen      the truth, confidence 1 where a photo sees the surface
//     truth     the truth, confidence 1 everywhere
//
// Where the confidence is 0, frames remain as they were rendered. A photo sees a surface point if its depth in the photo is
// at most 1 + T times the photo's true depth there (T: default 0.05, as in `gsfix masks`). --far gives a depth, in units of
// the scene, to pixels that have none (sky); without it nothing is there for a photo to see. `masks` and `restore` print a
// JSON object.
#include "../examples/gsfix.h"

#include <math.h>

#define TRY(call)                                      \
    do {                                               \
        const gsf_result try_result = (call);          \
        if (try_result != GSF_OK) return try_result;   \
    } while (0)

typedef struct oracle_options {
    double tolerance, far, sigma, near;
    int max_size, factor;
} oracle_options;

typedef struct truth_view {
    gsf_camera camera;
    gsf_image color; // f32; without data if only depth is needed
    gsf_image depth; // f32; 0: no surface
    double center[3];
} truth_view;

typedef struct view_list {
    truth_view* views;
    size_t count;
} view_list;

static float* row_of(const gsf_image* image, int64_t y) {
    return (float*)(void*)((char*)image->data + y * image->stride_y);
}

// ---- truth -----------------------------------------------------------------------

static void free_views(gsf_context* ctx, view_list* list) {
    for (size_t i = 0; i < list->count; i++) {
        gsf_destroy_image(ctx, &list->views[i].color);
        gsf_destroy_image(ctx, &list->views[i].depth);
    }
    gsf_free(ctx, list->views);
    memset(list, 0, sizeof *list);
}

static gsf_result check_size(gsf_context* ctx, const char* path, const gsf_image* image, const gsf_camera* camera) {
    if (image->width == camera->width && image->height == camera->height) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %lld x %lld, but the camera's pictures are %d x %d", path,
                    (long long)image->width, (long long)image->height, (int)camera->width, (int)camera->height);
}

static gsf_result load_color(gsf_context* ctx, const char* path, const gsf_camera* camera, gsf_image* out) { // as f32
    gsf_image file;
    TRY(gsf_load_image(ctx, path, 3, &file));
    gsf_result result = check_size(ctx, path, &file, camera);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, file.width, file.height, 3, out);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &file, out);
    gsf_destroy_image(ctx, &file);
    return result;
}

static gsf_result load_depth(gsf_context* ctx, const char* path, const gsf_camera* camera, double far, gsf_image* out) {
    TRY(gsfix_load_npy(ctx, path, out));
    TRY(check_size(ctx, path, out, camera));
    for (int64_t y = 0; y < out->height && far > 0.0; y++)
        for (int64_t x = 0; x < out->width; x++)
            if (!(row_of(out, y)[x] > 0.0f)) row_of(out, y)[x] = (float)far;
    return GSF_OK;
}

static gsf_result load_view(gsf_context* ctx, const char* folder, size_t i, int with_color, double far,
                            truth_view* view) {
    gsf_get_camera_center(&view->camera, view->center);
    TRY(load_depth(ctx, gsfix_pathf("%s/depth/%05zu.npy", folder, i).s, &view->camera, far, &view->depth));
    return with_color ? load_color(ctx, gsfix_pathf("%s/%05zu.png", folder, i).s, &view->camera, &view->color) : GSF_OK;
}

static gsf_result load_views(gsf_context* ctx, const char* cameras, const char* folder, int with_color, double far,
                             view_list* out) {
    gsf_camera* list = NULL;
    size_t count = 0;
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_load_cameras(ctx, cameras, &list, &count);
    if (result == GSF_OK) out->views = (truth_view*)gsf_alloc_zeroed(ctx, count + 1, sizeof *out->views);
    if (result == GSF_OK && !out->views) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) out->count = count;
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        out->views[i].camera = list[i];
        result = load_view(ctx, folder, i, with_color, far, out->views + i);
    }
    gsf_free(ctx, list);
    if (result != GSF_OK) free_views(ctx, out);
    return result;
}

static void unproject(const gsf_camera* camera, int64_t x, int64_t y, double z, double out[3]) {
    const double* m = camera->w2c;
    const double p[3] = {((double)x + 0.5 - camera->cx) / camera->fx * z - m[12],
                         ((double)y + 0.5 - camera->cy) / camera->fy * z - m[13], z - m[14]};
    for (int c = 0; c < 3; c++) out[c] = m[4 * c] * p[0] + m[4 * c + 1] * p[1] + m[4 * c + 2] * p[2];
}

// Does the photo see the point? u, v receive its position, even if it does not.
static int sees(const truth_view* photo, const double point[3], double tolerance, double* u, double* v) {
    double z;
    if (!gsf_project_point(&photo->camera, point, u, v, &z)) return 0;
    if (!(*u >= 0.0 && *v >= 0.0 && *u < photo->camera.width && *v < photo->camera.height)) return 0;
    return z <= (1.0 + tolerance) * (double)row_of(&photo->depth, (int64_t)*v)[(int64_t)*u];
}

static int seen_by_any(const view_list* photos, const truth_view* view, int64_t x, int64_t y, double tolerance) {
    const double z = (double)row_of(&view->depth, y)[x];
    double point[3], u, v;
    if (!(z > 0.0)) return 0;
    unproject(&view->camera, x, y, z, point);
    for (size_t k = 0; k < photos->count; k++)
        if (sees(photos->views + k, point, tolerance, &u, &v)) return 1;
    return 0;
}

// ---- a window --------------------------------------------------------------------

typedef struct job {
    gsf_context* ctx;
    const oracle_options* o;
    const char* folder;
    view_list truth;        // of the frames
    view_list photos;       // true depth at the photos, with the photos' own colours
    gsf_image *color, *depth, *out_color, *out_confidence; // of the frames, f32
    gsf_camera* cameras;
    int32_t* reference;     // index of the photo at this frame's view, or -1
} job;

static gsf_image* make_list(gsf_context* ctx, size_t count) {
    return (gsf_image*)gsf_alloc_zeroed(ctx, count + 1, sizeof(gsf_image));
}

static void free_list(gsf_context* ctx, gsf_image* list, size_t count) {
    for (size_t i = 0; list && i < count; i++) gsf_destroy_image(ctx, list + i);
    gsf_free(ctx, list);
}

static void free_job(job* j) {
    free_list(j->ctx, j->color, j->truth.count);
    free_list(j->ctx, j->depth, j->truth.count);
    free_list(j->ctx, j->out_color, j->truth.count);
    free_list(j->ctx, j->out_confidence, j->truth.count);
    gsf_free(j->ctx, j->cameras);
    gsf_free(j->ctx, j->reference);
    free_views(j->ctx, &j->truth);
    free_views(j->ctx, &j->photos);
}

// Frames that are a photo's view are named after it in cameras.json: "refs/00002.png".
static gsf_result read_references(job* j) {
    const gsfix_path path = gsfix_pathf("%s/cameras.json", j->folder);
    void* data;
    size_t size, i = 0;
    gsf_json json;
    TRY(gsf_read_file(j->ctx, path.s, &data, &size));
    gsf_result result = gsf_parse_json(j->ctx, path.s, (const char*)data, size, &json);
    gsf_free(j->ctx, data);
    if (result != GSF_OK) return result;
    const gsf_json_value* list = gsf_find_json_member(&json, &json.values[0], "cameras");
    for (uint32_t at = list ? list->child : 0; at && i < j->truth.count; at = json.values[at].next, i++) {
        const gsf_json_value* name = gsf_find_json_member(&json, &json.values[at], "name");
        int photo = -1;
        if (!name || name->type != GSF_JSON_STRING || sscanf(name->string, "refs/%d.png", &photo) != 1) photo = -1;
        j->reference[i] = photo >= 0 && (size_t)photo < j->photos.count ? photo : -1;
    }
    gsf_destroy_json(j->ctx, &json);
    return GSF_OK;
}

static gsf_result load_frame(job* j, size_t i) {
    const truth_view* truth = j->truth.views + i;
    const gsf_camera* camera = &truth->camera;
    j->cameras[i] = *camera;
    TRY(load_color(j->ctx, gsfix_pathf("%s/frames/%05zu.png", j->folder, i).s, camera, j->color + i));
    TRY(load_depth(j->ctx, gsfix_pathf("%s/depth/%05zu.npy", j->folder, i).s, camera, 0.0, j->depth + i));
    TRY(gsf_make_image(j->ctx, GSF_F32, camera->width, camera->height, 3, j->out_color + i));
    return gsf_make_image(j->ctx, GSF_F32, camera->width, camera->height, 1, j->out_confidence + i);
}

static gsf_result load_job(job* j, const char* truth, const char* photo_truth) {
    gsf_context* ctx = j->ctx;
    TRY(load_views(ctx, gsfix_pathf("%s/cameras.json", j->folder).s, truth, 1, j->o->far, &j->truth));
    TRY(load_views(ctx, gsfix_pathf("%s/refs/cameras.json", j->folder).s, photo_truth, 0, j->o->far, &j->photos));
    for (size_t i = 0; i < j->photos.count; i++)
        TRY(load_color(ctx, gsfix_pathf("%s/refs/%05zu.png", j->folder, i).s, &j->photos.views[i].camera,
                       &j->photos.views[i].color));
    const size_t n = j->truth.count;
    j->color = make_list(ctx, n);
    j->depth = make_list(ctx, n);
    j->out_color = make_list(ctx, n);
    j->out_confidence = make_list(ctx, n);
    j->cameras = (gsf_camera*)gsf_alloc(ctx, n + 1, sizeof *j->cameras);
    j->reference = (int32_t*)gsf_alloc(ctx, n + 1, sizeof *j->reference);
    if (!j->color || !j->depth || !j->out_color || !j->out_confidence || !j->cameras || !j->reference)
        return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < n; i++) TRY(load_frame(j, i));
    for (size_t i = 0; i < n; i++) j->reference[i] = -1;
    return read_references(j);
}

static gsf_result save_job(const job* j) {
    for (size_t i = 0; i < j->truth.count; i++) {
        TRY(gsf_save_image(j->ctx, gsfix_pathf("%s/out/%05zu.png", j->folder, i).s, j->out_color + i));
        TRY(gsf_save_image(j->ctx, gsfix_pathf("%s/confidence/%05zu.png", j->folder, i).s, j->out_confidence + i));
    }
    return GSF_OK;
}

// ---- the rows --------------------------------------------------------------------

// The library's warp restorer, run on the job's files.
static gsf_result run_warp(job* j) {
    gsf_context* ctx = j->ctx;
    gsf_restorer warp;
    const size_t photos = j->photos.count;
    gsf_image *render = make_list(ctx, photos), *depth = make_list(ctx, photos);
    gsf_reference* references = (gsf_reference*)gsf_alloc_zeroed(ctx, photos + 1, sizeof *references);
    gsf_result result = render && depth && references ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < photos && result == GSF_OK; i++) {
        const gsf_camera* camera = &j->photos.views[i].camera;
        result = load_color(ctx, gsfix_pathf("%s/refs/render/%05zu.png", j->folder, i).s, camera, render + i);
        if (result == GSF_OK)
            result = load_depth(ctx, gsfix_pathf("%s/refs/depth/%05zu.npy", j->folder, i).s, camera, 0.0, depth + i);
        references[i].camera = *camera;
        references[i].color = j->photos.views[i].color;
        references[i].render = render[i];
        references[i].depth = depth[i];
    }
    gsf_restore_window window;
    memset(&window, 0, sizeof window);
    window.struct_size = sizeof window;
    window.frame_count = (int32_t)j->truth.count;
    window.color = j->color;
    window.depth = j->depth;
    window.cameras = j->cameras;
    window.reference_index = j->reference;
    window.out_color = j->out_color;
    window.out_confidence = j->out_confidence;
    if (result == GSF_OK) {
        result = gsf_splat_make_warp(ctx, &warp);
        if (result == GSF_OK) {
            result = warp.begin_fn(warp.user, ctx, references, (int32_t)photos);
            if (result == GSF_OK) {
                result = warp.restore_fn(warp.user, ctx, &window);
                warp.end_fn(warp.user, ctx);
            }
            gsf_destroy_restorer(ctx, &warp);
        }
    }
    free_list(ctx, render, photos);
    free_list(ctx, depth, photos);
    gsf_free(ctx, references);
    return result;
}

static void set_all(gsf_image* image, float value) { // of one channel
    for (int64_t y = 0; y < image->height; y++)
        for (int64_t x = 0; x < image->width; x++) row_of(image, y)[x] = value;
}

static void copy_truth(job* j, size_t i) {
    const gsf_image* from = &j->truth.views[i].color;
    for (int64_t y = 0; y < from->height; y++)
        memcpy(row_of(j->out_color + i, y), row_of(from, y), 3 * (size_t)from->width * sizeof(float));
}

static void mark_seen(job* j, size_t i) { // confidence 1 where a photo sees the surface, else 0
    gsf_image* out = j->out_confidence + i;
    for (int64_t y = 0; y < out->height; y++)
        for (int64_t x = 0; x < out->width; x++)
            row_of(out, y)[x] = (float)seen_by_any(&j->photos, j->truth.views + i, x, y, j->o->tolerance);
}

// One pass of a Gaussian along x or y; pixels outside the image are excluded from the mean.
static void blur_pass(const gsf_image* from, const gsf_image* to, double sigma, int along_y) {
    const int64_t reach = (int64_t)ceil(3.0 * sigma), length = along_y ? from->height : from->width;
    for (int64_t y = 0; y < from->height; y++)
        for (int64_t x = 0; x < from->width; x++) {
            const int64_t at = along_y ? y : x;
            double sum[3] = {0}, total = 0.0;
            for (int64_t d = -reach; d <= reach; d++) {
                if (at + d < 0 || at + d >= length) continue;
                const double weight = exp(-0.5 * (double)(d * d) / (sigma * sigma));
                const float* p = along_y ? row_of(from, y + d) + 3 * x : row_of(from, y) + 3 * (x + d);
                total += weight;
                for (int c = 0; c < 3; c++) sum[c] += weight * (double)p[c];
            }
            for (int c = 0; c < 3; c++) row_of(to, y)[3 * x + c] = (float)(sum[c] / total);
        }
}

static gsf_result blur_truth(job* j, size_t i) {
    const gsf_image* truth = &j->truth.views[i].color;
    gsf_image between;
    TRY(gsf_make_image(j->ctx, GSF_F32, truth->width, truth->height, 3, &between));
    blur_pass(truth, &between, j->o->sigma, 0);
    blur_pass(&between, j->out_color + i, j->o->sigma, 1);
    gsf_destroy_image(j->ctx, &between);
    return GSF_OK;
}

#define CARRY_ANGLE 0.2 // radians, as GSF__WARP_ANGLE: a photo this far off in viewing direction weighs exp(-1/2)
// relative to depth: pixels farther than this in front of or behind the point show another surface
#define CARRY_EDGE 0.1

// Colour of the photo at (u, v) if it shows a point at camera depth z: interpolated bilinearly from those of the four
// neighbouring pixels that show the same surface. Returns 0 if none does.
static int carried_color(const truth_view* photo, double u, double v, double z, double rgb[3]) {
    const double fx = floor(u - 0.5), fy = floor(v - 0.5);
    double sum[3] = {0}, total = 0.0;
    for (int k = 0; k < 4; k++) {
        const double px = fx + (k & 1), py = fy + (k >> 1);
        if (px < 0.0 || py < 0.0 || px >= photo->camera.width || py >= photo->camera.height) continue;
        const double depth = (double)row_of(&photo->depth, (int64_t)py)[(int64_t)px];
        if (!(fabs(depth - z) <= CARRY_EDGE * z)) continue;
        const double weight = (1.0 - fabs(u - 0.5 - px)) * (1.0 - fabs(v - 0.5 - py));
        const float* color = row_of(&photo->color, (int64_t)py) + 3 * (int64_t)px;
        total += weight;
        for (int c = 0; c < 3; c++) sum[c] += weight * (double)color[c];
    }
    for (int c = 0; c < 3 && total > 0.0; c++) rgb[c] = sum[c] / total;
    return total > 0.0;
}

static double angle_weight(const double point[3], const double a[3], const double b[3]) {
    double along = 0.0, n0 = 0.0, n1 = 0.0;
    for (int c = 0; c < 3; c++) {
        const double p = point[c] - a[c], q = point[c] - b[c];
        along += p * q;
        n0 += p * p;
        n1 += q * q;
    }
    const double cosine = along / sqrt(n0 * n1 + 1e-300), square = 2.0 - 2.0 * (cosine < 1.0 ? cosine : 1.0);
    return exp(-0.5 * square / (CARRY_ANGLE * CARRY_ANGLE)) + 1e-6;
}

static void carry_photos(job* j, size_t i) {
    const truth_view* view = j->truth.views + i;
    for (int64_t y = 0; y < view->depth.height; y++)
        for (int64_t x = 0; x < view->depth.width; x++) {
            const double depth = (double)row_of(&view->depth, y)[x];
            double point[3], sum[3] = {0}, total = 0.0;
            if (depth > 0.0) unproject(&view->camera, x, y, depth, point);
            for (size_t k = 0; k < j->photos.count && depth > 0.0; k++) {
                const truth_view* photo = j->photos.views + k;
                double u, v, z, again[2], rgb[3];
                if (!sees(photo, point, j->o->tolerance, &u, &v)) continue;
                gsf_project_point(&photo->camera, point, again, again + 1, &z);
                if (!carried_color(photo, u, v, z, rgb)) continue;
                const double weight = angle_weight(point, view->center, photo->center);
                total += weight;
                for (int c = 0; c < 3; c++) sum[c] += weight * rgb[c];
            }
            for (int c = 0; c < 3 && total > 0.0; c++) row_of(j->out_color + i, y)[3 * x + c] = (float)(sum[c] / total);
            row_of(j->out_confidence + i, y)[x] = total > 0.0 ? 1.0f : 0.0f;
        }
}

static void keep_render(job* j, size_t i) { // where the confidence is 0
    const gsf_image* confidence = j->out_confidence + i;
    for (int64_t y = 0; y < confidence->height; y++)
        for (int64_t x = 0; x < confidence->width; x++)
            if (!(row_of(confidence, y)[x] > 0.0f))
                memcpy(row_of(j->out_color + i, y) + 3 * x, row_of(j->color + i, y) + 3 * x, 3 * sizeof(float));
}

static const char* const rows[] = {"warp", "carried", "masked", "blurred", "seen", "truth"};
enum { ROW_WARP, ROW_CARRIED, ROW_MASKED, ROW_BLURRED, ROW_SEEN, ROW_TRUTH, ROW_COUNT };

static gsf_result restore_window(job* j, int row) {
    if (row == ROW_WARP || row == ROW_MASKED) TRY(run_warp(j));
    for (size_t i = 0; i < j->truth.count; i++) {
        if (row == ROW_CARRIED) carry_photos(j, i);
        if (row == ROW_MASKED || row == ROW_SEEN || row == ROW_TRUTH) copy_truth(j, i);
        if (row == ROW_BLURRED) TRY(blur_truth(j, i));
        if (row == ROW_SEEN) mark_seen(j, i);
        if (row == ROW_TRUTH || row == ROW_BLURRED) set_all(j->out_confidence + i, 1.0f);
        keep_render(j, i);
    }
    return GSF_OK;
}

// ---- quality of the frames -------------------------------------------------------

enum {
    PIXELS, RENDER_ERROR, RESTORED_ERROR, // squared errors against the truth, mean over the channels
    REACHED, REACHED_RENDER_ERROR, REACHED_RESTORED_ERROR, // the same over the pixels with confidence
    CONFIDENCE, SEEN, // sum; pixels that a photo sees
    SUMS
};
static const char* const sum_names[SUMS] = {
    "pixels", "render_error", "restored_error", "reached", "reached_render_error", "reached_restored_error",
    "confidence", "seen"};

static double square_error(const gsf_image* a, const gsf_image* b, int64_t x, int64_t y) { // mean over the channels
    double sum = 0.0;
    for (int64_t c = 3 * x; c < 3 * x + 3; c++) {
        const double d = (double)row_of(a, y)[c] - (double)row_of(b, y)[c];
        sum += d * d / 3.0;
    }
    return sum;
}

static void add_sums(const job* j, size_t i, double sums[SUMS]) {
    const truth_view* truth = j->truth.views + i;
    for (int64_t y = 0; y < truth->depth.height; y++)
        for (int64_t x = 0; x < truth->depth.width; x++) {
            const double confidence = (double)row_of(j->out_confidence + i, y)[x];
            const double before = square_error(j->color + i, &truth->color, x, y);
            const double after = square_error(j->out_color + i, &truth->color, x, y);
            sums[PIXELS] += 1.0;
            sums[RENDER_ERROR] += before;
            sums[RESTORED_ERROR] += after;
            sums[CONFIDENCE] += confidence;
            sums[SEEN] += seen_by_any(&j->photos, truth, x, y, j->o->tolerance);
            if (!(confidence > 0.0)) continue;
            sums[REACHED] += 1.0;
            sums[REACHED_RENDER_ERROR] += before;
            sums[REACHED_RESTORED_ERROR] += after;
        }
}

static void print_sums(const job* j) { // of the frames used for training, which excludes those at a photo's view
    gsf_buffer text = {0};
    double sums[SUMS] = {0};
    size_t frames = 0;
    for (size_t i = 0; i < j->truth.count; i++) {
        if (j->reference[i] >= 0) continue;
        add_sums(j, i, sums);
        frames++;
    }
    gsfix_json_begin(j->ctx, &text, NULL, '{');
    gsfix_json_number(j->ctx, &text, "frames", (double)frames);
    for (int k = 0; k < SUMS; k++) gsfix_json_number(j->ctx, &text, sum_names[k], sums[k]);
    gsfix_json_end(j->ctx, &text, '}');
    printf("%s\n", text.data ? text.data : "{}");
    gsf_destroy_buffer(j->ctx, &text);
}

// ---- commands --------------------------------------------------------------------

static gsf_result run_restore(gsf_context* ctx, const oracle_options* o, const char** argument) {
    job j;
    int row = 0;
    while (row < ROW_COUNT && strcmp(argument[0], rows[row]) != 0) row++;
    if (row == ROW_COUNT) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "no row \"%s\"", argument[0]);
    memset(&j, 0, sizeof j);
    j.ctx = ctx;
    j.o = o;
    j.folder = argument[1];
    gsf_result result = load_job(&j, argument[2], argument[3]);
    if (result == GSF_OK) result = restore_window(&j, row);
    if (result == GSF_OK) result = save_job(&j);
    if (result == GSF_OK) print_sums(&j);
    free_job(&j);
    return result;
}

static gsf_result run_masks(gsf_context* ctx, const oracle_options* o, const char** argument) {
    view_list views, photos;
    gsf_buffer text = {0};
    TRY(load_views(ctx, argument[0], argument[1], 0, o->far, &views));
    gsf_result result = load_views(ctx, argument[2], argument[3], 0, o->far, &photos);
    if (result == GSF_OK) result = gsfix_make_folder(ctx, argument[4]);
    gsfix_json_begin(ctx, &text, NULL, '{');
    gsfix_json_begin(ctx, &text, "seen", '[');
    for (size_t i = 0; i < views.count && result == GSF_OK; i++) {
        const gsf_camera* camera = &views.views[i].camera;
        double seen = 0.0;
        gsf_image mask;
        result = gsf_make_image(ctx, GSF_U8, camera->width, camera->height, 1, &mask);
        if (result != GSF_OK) break;
        for (int64_t y = 0; y < mask.height; y++)
            for (int64_t x = 0; x < mask.width; x++) {
                const int is_seen = seen_by_any(&photos, views.views + i, x, y, o->tolerance);
                ((uint8_t*)mask.data)[y * mask.width + x] = is_seen ? 255 : 0;
                seen += is_seen;
            }
        result = gsf_save_image(ctx, gsfix_pathf("%s/%05zu.png", argument[4], i).s, &mask);
        gsfix_json_number(ctx, &text, NULL, seen / ((double)mask.width * (double)mask.height));
        gsf_destroy_image(ctx, &mask);
    }
    gsfix_json_end(ctx, &text, ']');
    gsfix_json_end(ctx, &text, '}');
    if (result == GSF_OK) printf("%s\n", text.data ? text.data : "{}");
    gsf_destroy_buffer(ctx, &text);
    free_views(ctx, &views);
    free_views(ctx, &photos);
    return result;
}

static gsf_result render_one(gsf_context* ctx, gsf_rasterizer* rasterizer, const gsf_splats* splats,
                             const gsf_camera* camera, const gsf_render_desc* desc, const char* folder, size_t i) {
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    gsf_result result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &out.color);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &out.depth);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &out.alpha);
    if (result == GSF_OK) result = gsf_splat_render(ctx, rasterizer, splats, camera, desc, &out);
    for (int64_t y = 0; y < camera->height && result == GSF_OK; y++)
        for (int64_t x = 0; x < camera->width; x++)
            if (row_of(&out.alpha, y)[x] < 0.5f) row_of(&out.depth, y)[x] = 0.0f; // no surface
    if (result == GSF_OK) result = gsf_save_image(ctx, gsfix_pathf("%s/%05zu.png", folder, i).s, &out.color);
    if (result == GSF_OK) result = gsfix_save_npy(ctx, gsfix_pathf("%s/depth/%05zu.npy", folder, i).s, &out.depth);
    gsf_destroy_image(ctx, &out.color);
    gsf_destroy_image(ctx, &out.depth);
    gsf_destroy_image(ctx, &out.alpha);
    return result;
}

static gsf_result run_render(gsf_context* ctx, const oracle_options* o, const char** argument) {
    gsf_splats splats;
    gsf_camera* cameras = NULL;
    size_t count = 0;
    gsf_rasterizer* rasterizer = NULL;
    gsf_render_desc desc;
    memset(&desc, 0, sizeof desc);
    TRY(gsf_splat_load(ctx, argument[0], &splats));
    desc.antialiased = splats.antialiased;
    desc.near_plane = (float)o->near;
    gsf_result result = gsf_load_cameras(ctx, argument[1], &cameras, &count);
    if (result == GSF_OK) result = gsfix_make_folder(ctx, gsfix_pathf("%s/depth", argument[2]).s);
    if (result == GSF_OK) result = gsf_splat_make_rasterizer(ctx, &rasterizer);
    for (size_t i = 0; i < count && result == GSF_OK; i++)
        result = render_one(ctx, rasterizer, &splats, cameras + i, &desc, argument[2], i);
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    gsf_free(ctx, cameras);
    gsf_splat_destroy(ctx, &splats);
    return result;
}

static gsf_result run_cameras(gsf_context* ctx, const oracle_options* o, const char** argument) {
    gsf_scene scene;
    gsf_scene_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.max_size = o->max_size;
    desc.factor = o->factor;
    TRY(gsf_splat_load_scene(ctx, argument[0], &desc, &scene));
    gsf_camera* cameras = (gsf_camera*)gsf_alloc(ctx, scene.view_count + 1, sizeof *cameras);
    const char** names = (const char**)gsf_alloc(ctx, scene.view_count + 1, sizeof *names);
    gsf_result result = cameras && names ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < scene.view_count && result == GSF_OK; i++) {
        cameras[i] = scene.views[i].camera;
        names[i] = scene.views[i].name;
    }
    if (result == GSF_OK) result = gsf_save_cameras(ctx, argument[1], cameras, names, scene.view_count);
    gsf_free(ctx, (void*)names);
    gsf_free(ctx, cameras);
    gsf_splat_destroy_scene(ctx, &scene);
    return result;
}

static const struct {
    const char *name, *usage;
    int arguments;
    gsf_result (*run)(gsf_context* ctx, const oracle_options* o, const char** argument);
} commands[] = {
    {"cameras", "SCENE OUT.json [--max-size N | --factor N]", 2, run_cameras},
    {"render", "SPLATS CAMERAS.json OUT [--near Z]", 3, run_render},
    {"masks", "CAMERAS.json TRUTH PHOTOS.json PHOTO_TRUTH OUT [--tolerance T] [--far Z]", 5, run_masks},
    {"restore", "warp|carried|masked|blurred|seen|truth JOBDIR TRUTH PHOTO_TRUTH [--tolerance T] [--far Z] [--sigma S]",
     4, run_restore},
};
enum { COMMAND_COUNT = sizeof commands / sizeof commands[0], MOST_ARGUMENTS = 5 };

static int usage(FILE* to) {
    for (int i = 0; i < COMMAND_COUNT; i++) fprintf(to, "oracle %s %s\n", commands[i].name, commands[i].usage);
    return to == stdout ? 0 : 2;
}

static int read_option(oracle_options* o, const char* name, const char* text) {
    char* end;
    const double x = strtod(text, &end);
    if (end == text || *end || !(x > 0.0 && x < 1e9)) return 0;
    if (strcmp(name, "--tolerance") == 0) o->tolerance = x;
    else if (strcmp(name, "--far") == 0) o->far = x;
    else if (strcmp(name, "--sigma") == 0) o->sigma = x;
    else if (strcmp(name, "--near") == 0) o->near = x;
    else if (strcmp(name, "--max-size") == 0) o->max_size = (int)x;
    else if (strcmp(name, "--factor") == 0) o->factor = (int)x;
    else return 0;
    return 1;
}

int main(int argc, char** argv) {
    oracle_options o = {0.05, 0.0, 2.0, 0.0, 0, 0};
    const char* argument[MOST_ARGUMENTS];
    int command = 0, count = 0;
    if (argc == 2 && strcmp(argv[1], "--help") == 0) return usage(stdout);
    while (command < COMMAND_COUNT && (argc < 2 || strcmp(argv[1], commands[command].name) != 0)) command++;
    if (command == COMMAND_COUNT) return usage(stderr);
    for (int i = 2; i < argc; i++) {
        if (strncmp(argv[i], "--", 2) == 0) {
            if (i + 1 >= argc || !read_option(&o, argv[i], argv[i + 1])) return usage(stderr);
            i++;
        } else {
            if (count == commands[command].arguments) return usage(stderr);
            argument[count++] = argv[i];
        }
    }
    if (count != commands[command].arguments) return usage(stderr);
    gsf_context ctx = {0};
    gsf_result result = gsf_init_context(&ctx);
    if (result == GSF_OK) result = commands[command].run(&ctx, &o, argument);
    if (result != GSF_OK)
        fprintf(stderr, "oracle %s: %s\n", argv[1], result == GSF_ERROR_OUT_OF_MEMORY ? "out of memory" : ctx.error);
    return result == GSF_OK ? 0 : 1;
}
