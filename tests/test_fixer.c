// test_fixer.c - the restorer warp on an analytic scene, and the repair loop: schedule, legal sizes, skipping, failing
// restorers, cancellation, and checkpoints that resume bit-identically.
#include "gsfixer_splat.h"
#include "test.h"
#include "test_hooks.h"

// ---- warp ----------------------------------------------------------------------

// A slanted, textured plane z = 4 + 0.3 x.
static void plane_color(double x, double y, float rgb[3]) {
    rgb[0] = (float)(0.5 + 0.4 * sin(3.0 * x) * cos(2.0 * y));
    rgb[1] = (float)(0.5 + 0.4 * sin(2.0 * y + 1.0));
    rgb[2] = (float)(0.5 + 0.4 * cos(2.5 * x + y));
}

// Camera at (x, y, 0), turned by `angle` about y.
static gsf_camera look(double x, double y, double angle, int width, int height) {
    gsf_camera c;
    memset(&c, 0, sizeof c);
    double c2w[16] = {cos(angle), 0, -sin(angle), 0, 0, 1, 0, 0, sin(angle), 0, cos(angle), 0, x, y, 0, 1};
    c.fx = c.fy = 0.9 * width;
    c.cx = 0.5 * width;
    c.cy = 0.5 * height;
    c.width = width;
    c.height = height;
    gsf_set_camera_c2w(&c, c2w);
    return c;
}

static void draw_plane(const gsf_camera* camera, float* color, float* depth) {
    double c2w[16], center[3];
    gsf_get_camera_c2w(camera, c2w);
    gsf_get_camera_center(camera, center);
    for (int y = 0; y < camera->height; y++)
        for (int x = 0; x < camera->width; x++) {
            const double ray[3] = {(x + 0.5 - camera->cx) / camera->fx, (y + 0.5 - camera->cy) / camera->fy, 1.0};
            double d[3];
            for (int r = 0; r < 3; r++) d[r] = c2w[r] * ray[0] + c2w[4 + r] * ray[1] + c2w[8 + r] * ray[2];
            const double t = (4.0 + 0.3 * center[0] - center[2]) / (d[2] - 0.3 * d[0]); // camera depth, since ray z = 1
            const size_t at = (size_t)y * (size_t)camera->width + (size_t)x;
            plane_color(center[0] + t * d[0], center[1] + t * d[1], color + 3 * at);
            depth[at] = (float)t;
        }
}

// A window of one frame; `window` points to the images next to it.
typedef struct one_frame {
    gsf_image color, restored, confidence;
    gsf_restore_window window;
} one_frame;

static void one_frame_init(one_frame* frame, const gsf_camera* camera, float* color, float* restored, float* confidence) {
    memset(frame, 0, sizeof *frame);
    frame->color = gsf_wrap_image(color, GSF_F32, camera->width, camera->height, 3);
    frame->restored = gsf_wrap_image(restored, GSF_F32, camera->width, camera->height, 3);
    frame->confidence = gsf_wrap_image(confidence, GSF_F32, camera->width, camera->height, 1);
    frame->window.struct_size = sizeof frame->window;
    frame->window.frame_count = 1;
    frame->window.cameras = camera;
    frame->window.color = &frame->color;
    frame->window.out_color = &frame->restored;
    frame->window.out_confidence = &frame->confidence;
}

static void test_warp(gsf_context* ctx) {
    enum { W = 96, H = 64, N = W * H };
    static float color[3][3 * N], depth[3][N], out_color[3 * N], out_confidence[N], gray[3 * N];
    const gsf_camera cameras[3] = {look(-0.5, 0.0, 0.1, W, H), look(0.5, 0.1, -0.1, W, H), look(0.1, 0.05, 0.0, W, H)};
    gsf_reference references[2];
    memset(references, 0, sizeof references);
    for (int i = 0; i < 3; i++) draw_plane(&cameras[i], color[i], depth[i]);
    for (int i = 0; i < 2; i++) {
        references[i].camera = cameras[i];
        references[i].color = gsf_wrap_image(color[i], GSF_F32, W, H, 3);
        references[i].depth = gsf_wrap_image(depth[i], GSF_F32, W, H, 1);
    }
    for (int i = 0; i < 3 * N; i++) gray[i] = 0.25f;
    gsf_restorer warp;
    one_frame frame;
    one_frame_init(&frame, &cameras[2], gray, out_color, out_confidence);
    CHECK_OK(ctx, gsf_splat_make_warp(ctx, &warp));
    for (int32_t side = 255; side <= 257; side++) { // large photos are repaired at half their size
        gsf_restorer_info info;
        memset(&info, 0, sizeof info);
        info.struct_size = sizeof info;
        CHECK_OK(ctx, warp.query_fn(warp.user, ctx, 17, side, 500, &info));
        CHECK(info.frame_scale == (side < 256 ? 0.0f : 0.5f));
        CHECK(info.lambda == 0.5f && info.lambda_views == 6);
    }
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 2));
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    int covered = 0;
    double worst = 0.0;
    for (int i = 0; i < N; i++) {
        if (out_confidence[i] <= 0.0f) {
            CHECK(out_color[3 * i] == 0.25f); // not seen by any reference: the render is kept
            continue;
        }
        covered++;
        for (int c = 0; c < 3; c++) worst = fmax(worst, fabs((double)(out_color[3 * i + c] - color[2][3 * i + c])));
    }
    CHECK(covered > N * 9 / 10);
    CHECK_NEAR(worst, 0.0, 0.03); // bilinear sampling of the texture, at the depth that stereo finds
    // a reference with a much smaller depth contradicts the other and is rejected
    for (int i = 0; i < N; i++)
        if (i % W > 20 && i % W < 50) depth[0][i] = 1.5f;
    warp.end_fn(warp.user, ctx);
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 2));
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    double error = 0.0, weight = 0.0;
    for (int i = 0; i < N; i++) {
        weight += (double)out_confidence[i];
        error += (double)out_confidence[i] * fabs((double)(out_color[3 * i] - color[2][3 * i]));
    }
    CHECK(weight > 0.5 * N && error / weight < 0.02);
    // a frame with a reference's pose is that photo
    const int32_t known = 1;
    frame.window.cameras = &cameras[1];
    frame.window.reference_index = &known;
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    for (int i = 0; i < N; i += 7) CHECK_NEAR(out_color[3 * i], color[1][3 * i], 1e-6);
    warp.end_fn(warp.user, ctx);
    CHECK_RESULT(ctx, warp.begin_fn(warp.user, ctx, references, 0), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 2));
    CHECK_RESULT(ctx, warp.begin_fn(warp.user, ctx, references, 1), GSF_ERROR_INVALID_ARGUMENT); // already begun
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window)); // keeps its two references
    CHECK_NEAR(out_color[0], color[1][0], 1e-6);
    warp.end_fn(warp.user, ctx);
    references[1].depth.data = NULL;
    CHECK_RESULT(ctx, warp.begin_fn(warp.user, ctx, references, 2), GSF_ERROR_INVALID_ARGUMENT);
    gsf_destroy_restorer(ctx, &warp);
}

// References with renders. The splats here show the plane without its green, and the frame's exposure is 0.1 brighter.
// Where the photos verify the plane, the frame gets their colours. Where only the splats vouch for it, as for a single
// photo, the residual of the photo is added to the frame, and its exposure is kept.
static void test_warp_residual(gsf_context* ctx) {
    enum { W = 96, H = 64, N = W * H };
    static float color[4][3 * N], render[4][3 * N], depth[4][N], out_color[3 * N], out_confidence[N];
    const gsf_camera cameras[4] = {look(-0.2, 0.0, 0.1, W, H), look(0.2, 0.1, -0.1, W, H), look(9.0, 0.0, -0.9, W, H),
                                   look(0.05, 0.05, 0.0, W, H)};
    gsf_reference references[3];
    memset(references, 0, sizeof references);
    for (int i = 0; i < 4; i++) {
        draw_plane(&cameras[i], color[i], depth[i]);
        for (int p = 0; p < N; p++) {
            render[i][3 * p] = color[i][3 * p] + (i == 3 ? 0.1f : 0.0f);
            render[i][3 * p + 1] = i == 3 ? 0.1f : 0.0f;
            render[i][3 * p + 2] = color[i][3 * p + 2] + (i == 3 ? 0.1f : 0.0f);
        }
    }
    for (int i = 0; i < 3; i++) {
        references[i].camera = cameras[i];
        references[i].color = gsf_wrap_image(color[i], GSF_F32, W, H, 3);
        references[i].render = gsf_wrap_image(render[i], GSF_F32, W, H, 3);
        references[i].depth = gsf_wrap_image(depth[i], GSF_F32, W, H, 1);
    }
    gsf_restorer warp;
    one_frame frame;
    one_frame_init(&frame, &cameras[3], render[3], out_color, out_confidence);
    CHECK_OK(ctx, gsf_splat_make_warp(ctx, &warp));
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 3));
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    int whole = 0, wrong = 0;
    for (int i = 0; i < N; i++) {
        if (out_confidence[i] < 0.6f) continue;
        double off = 0.0;
        for (int c = 0; c < 3; c++) off = fmax(off, fabs((double)(out_color[3 * i + c] - color[3][3 * i + c])));
        wrong += off > 0.02;
        whole++;
    }
    CHECK(whole > N * 8 / 10 && wrong <= N / 1000); // stereo finds no exact depth at the photos' borders
    warp.end_fn(warp.user, ctx);
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 1));
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    whole = 0;
    for (int i = 0; i < N; i++) {
        if (out_confidence[i] <= 0.0f) continue;
        const double share = (double)(out_color[3 * i + 1] - 0.1f) / (double)color[3][3 * i + 1]; // of the green
        CHECK(out_confidence[i] < 0.5f && fabs((double)(out_color[3 * i] - render[3][3 * i])) < 0.02);
        CHECK(color[3][3 * i + 1] < 0.3f || (share > 0.5 && share < 0.7)); // not trusted fully
        whole++;
    }
    CHECK(whole > N * 8 / 10);
    // a reference with a very different viewing direction contributes almost nothing
    warp.end_fn(warp.user, ctx);
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references + 2, 1));
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    for (int i = 0; i < N; i++) {
        CHECK(out_confidence[i] < 0.05f);
        CHECK_NEAR(out_color[3 * i + 1], render[3][3 * i + 1], 0.1);
    }
    warp.end_fn(warp.user, ctx);
    gsf_destroy_restorer(ctx, &warp);
}

// 8-bit photos are kept as bytes. One other value per photo, and they are kept as floats: bit-identical frames elsewhere.
static void test_warp_bytes(gsf_context* ctx) {
    enum { W = 96, H = 64, N = W * H };
    static float color[2][3 * N], depth[2][N], gray[3 * N], out_color[2][3 * N], out_confidence[2][N];
    static uint8_t bytes[3 * N];
    const gsf_camera cameras[3] = {look(-0.5, 0.0, 0.1, W, H), look(0.5, 0.1, -0.1, W, H), look(0.1, 0.05, 0.0, W, H)};
    gsf_reference references[2];
    memset(references, 0, sizeof references);
    const gsf_image packed = gsf_wrap_image(bytes, GSF_U8, W, H, 3);
    for (int i = 0; i < 2; i++) {
        draw_plane(&cameras[i], color[i], depth[i]);
        references[i].camera = cameras[i];
        references[i].color = gsf_wrap_image(color[i], GSF_F32, W, H, 3);
        references[i].depth = gsf_wrap_image(depth[i], GSF_F32, W, H, 1);
        CHECK_OK(ctx, gsf_convert_image(ctx, &references[i].color, &packed));
        CHECK_OK(ctx, gsf_convert_image(ctx, &packed, &references[i].color));
    }
    gsf_restorer warp;
    CHECK_OK(ctx, gsf_splat_make_warp(ctx, &warp));
    for (int32_t known = -1; known < 1; known++) { // between the photos; at the first one
        for (int floats = 0; floats < 2; floats++) {
            const float was[2] = {color[0][0], color[1][0]};
            one_frame frame;
            one_frame_init(&frame, &cameras[known < 0 ? 2 : known], gray, out_color[floats], out_confidence[floats]);
            if (known >= 0) frame.window.reference_index = &known;
            for (int i = 0; i < 2 && floats; i++) color[i][0] += 1e-3f;
            CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 2));
            CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
            warp.end_fn(warp.user, ctx);
            for (int i = 0; i < 2; i++) color[i][0] = was[i];
        }
        int differ = 0, covered = 0;
        for (int i = 0; i < N; i++) {
            differ += memcmp(out_color[0] + 3 * i, out_color[1] + 3 * i, 3 * sizeof(float)) != 0;
            covered += out_confidence[0][i] > 0.0f;
        }
        CHECK(differ <= (known < 0 ? 8 : 1) && covered > N * 9 / 10);
        if (known == 0) CHECK(memcmp(out_color[0], color[0], sizeof color[0]) == 0 && differ == 1);
    }
    gsf_destroy_restorer(ctx, &warp);
}

// A splat in front of the plane that neither photo shows: the frame takes the plane behind it from the photos, with half the
// confidence. A single photo, or a second photo that shows the splat in place, does not change the frame.
static void test_warp_refutes(gsf_context* ctx) {
    enum { W = 96, H = 64, N = W * H };
    static float color[3][3 * N], depth[3][N], shown_color[3 * N], shown_depth[N], out_color[3 * N], out_confidence[N];
    const gsf_camera cameras[3] = {look(-0.8, 0.0, 0.1, W, H), look(0.8, 0.1, -0.1, W, H), look(0.0, 0.05, 0.0, W, H)};
    gsf_reference references[2];
    memset(references, 0, sizeof references);
    for (int i = 0; i < 3; i++) draw_plane(&cameras[i], color[i], depth[i]);
    for (int i = 0; i < 2; i++) {
        references[i].camera = cameras[i];
        references[i].color = references[i].render = gsf_wrap_image(color[i], GSF_F32, W, H, 3);
        references[i].depth = gsf_wrap_image(depth[i], GSF_F32, W, H, 1);
    }
    memcpy(shown_color, color[2], sizeof shown_color);
    memcpy(shown_depth, depth[2], sizeof shown_depth);
    for (int y = 24; y < 40; y++)
        for (int x = 40; x < 56; x++) {
            shown_depth[y * W + x] /= 1.2f;
            for (int c = 0; c < 3; c++) shown_color[3 * (y * W + x) + c] = 0.25f;
        }
    gsf_image seen = gsf_wrap_image(shown_depth, GSF_F32, W, H, 1);
    gsf_restorer warp;
    one_frame frame;
    one_frame_init(&frame, &cameras[2], shown_color, out_color, out_confidence);
    frame.window.depth = &seen;
    CHECK_OK(ctx, gsf_splat_make_warp(ctx, &warp));
    for (int photos = 1; photos <= 2; photos++) {
        CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, photos));
        CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
        double worst = 0.0;
        for (int y = 24; y < 40; y++)
            for (int x = 40; x < 56; x++) {
                const int at = y * W + x;
                const float* wanted = photos == 2 ? color[2] + 3 * at : shown_color + 3 * at;
                for (int c = 0; c < 3; c++) worst = fmax(worst, fabs((double)(out_color[3 * at + c] - wanted[c])));
                CHECK(photos == 2 ? fabsf(out_confidence[at] - 0.5f) < 0.03f : out_confidence[at] == 0.0f);
            }
        CHECK_NEAR(worst, 0.0, photos == 2 ? 0.03 : 1e-6);
        CHECK_NEAR(out_color[3 * (10 * W + 48)], color[2][3 * (10 * W + 48)], photos == 2 ? 0.01 : 1e-6); // next to it
        warp.end_fn(warp.user, ctx);
    }
    // photos that do not match verify nothing, and the second one shows leaves at most 4 pixels away: the splat is kept
    for (int i = 0; i < 3 * N; i++) color[1][i] = 1.0f - color[1][i];
    for (int i = 0; i < N; i++)
        if (i % W % 8 < 4) depth[1][i] /= 1.2f;
    CHECK_OK(ctx, warp.begin_fn(warp.user, ctx, references, 2));
    CHECK_OK(ctx, warp.restore_fn(warp.user, ctx, &frame.window));
    int changed = 0;
    for (int y = 24; y < 40; y++)
        for (int x = 40; x < 56; x++) changed += fabsf(out_color[3 * (y * W + x)] - 0.25f) > 1e-6f;
    CHECK(changed == 0);
    warp.end_fn(warp.user, ctx);
    gsf_destroy_restorer(ctx, &warp);
}

// ---- a small scene to repair ---------------------------------------------------

enum { WIDTH = 48, HEIGHT = 40, VIEWS = 4, TRUTH = 400, PIXELS = WIDTH * HEIGHT };

typedef struct repair {
    gsf_splats truth, start;
    gsf_rasterizer* rasterizer;
    gsf_train_view views[VIEWS];
    float photos[VIEWS][3 * PIXELS];
    gsf_restorer restorer;          // renders the ground truth
    int32_t multiple, frames_step;  // the restorer's limits
    gsf_restorer_info also;         // further limits: the frames that the restorer was trained for
    int begun, ended, windows, fail_at, checked, restored;
} repair;

static gsf_camera around(double angle, double height) { // on a circle of radius 4, looking at the centre
    const double eye[3] = {4.0 * sin(angle), height, -4.0 * cos(angle)}, target[3] = {0, 0, 0}, up[3] = {0, -1, 0};
    double pose[16];
    gsf_camera c = look(0, 0, 0, WIDTH, HEIGHT);
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    if (gsf_traj_look_at(&ctx, eye, target, up, pose) == GSF_OK) gsf_set_camera_c2w(&c, pose);
    return c;
}

static gsf_result repair_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                               gsf_restorer_info* out) {
    const repair* r = (const repair*)user;
    (void)ctx; (void)frames; (void)width; (void)height;
    CHECK(out->struct_size == sizeof *out);
    out->frame_count_min = 1;
    out->frame_count_step = r->frames_step;
    out->width_multiple = out->height_multiple = r->multiple;
    out->frame_count = r->also.frame_count;
    out->frame_count_max = r->also.frame_count_max;
    out->width = r->also.width;
    out->height = r->also.height;
    out->width_max = r->also.width_max;
    out->height_max = r->also.height_max;
    out->squash = r->also.squash;
    out->lambda = r->also.lambda;
    out->lambda_views = r->also.lambda_views;
    out->frame_scale = r->also.frame_scale;
    out->warp_weight = r->also.warp_weight;
    out->needs_depth = out->needs_alpha = 1;
    return GSF_OK;
}

static gsf_result repair_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    repair* r = (repair*)user;
    CHECK(count == VIEWS);
    CHECK(references[0].color.data != NULL && references[0].depth.data != NULL);
    (void)ctx;
    r->begun++;
    return GSF_OK;
}

// The frame contains the photo's full field of view and, if it is squashed to the frame's size, nothing else.
static void check_view(const repair* r, const gsf_camera* camera) {
    const gsf_camera* photo = &r->views[0].camera;
    const double left = camera->cx - photo->cx / photo->fx * camera->fx, top = camera->cy - photo->cy / photo->fy * camera->fy;
    const double right = left + photo->width / photo->fx * camera->fx, bottom = top + photo->height / photo->fy * camera->fy;
    if (r->also.squash) {
        CHECK_NEAR(left, 0.0, 1e-9);
        CHECK_NEAR(top, 0.0, 1e-9);
        CHECK_NEAR(right, camera->width, 1e-9);
        CHECK_NEAR(bottom, camera->height, 1e-9);
    } else if (r->also.width_max) { // square pixels in a frame of fixed size: scaled as large as possible
        CHECK(left > -1e-9 && top > -1e-9 && right < camera->width + 1e-9 && bottom < camera->height + 1e-9);
        CHECK(left < 1e-9 || top < 1e-9);
    }
}

static gsf_result repair_restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    repair* r = (repair*)user;
    if (r->fail_at && ++r->windows == r->fail_at) return gsf_fail(ctx, GSF_ERROR_RESTORER, "out of ideas");
    r->restored++;
    CHECK(window->depth != NULL && window->alpha != NULL && (window->frame_count - 1) % r->frames_step == 0);
    for (int32_t i = 0; i < window->frame_count; i++) {
        const gsf_camera* camera = window->cameras + i;
        CHECK(camera->width % r->multiple == 0 && camera->height % r->multiple == 0);
        if (!r->also.squash) CHECK_NEAR(camera->fx / camera->fy, 1.0, 1e-9); // nothing is squashed
        check_view(r, camera);
        gsf_render_output out;
        memset(&out, 0, sizeof out);
        out.color = window->out_color[i];
        CHECK_OK(ctx, gsf_splat_render(ctx, r->rasterizer, &r->truth, camera, NULL, &out));
        float* confidence = (float*)window->out_confidence[i].data;
        for (int32_t k = 0; k < camera->width * camera->height; k++) confidence[k] = 0.8f;
        if (window->reference_index[i] >= 0) r->checked++;
    }
    return GSF_OK;
}

static void repair_end(void* user, gsf_context* ctx) {
    (void)ctx;
    ((repair*)user)->ended++;
}

static void repair_setup(gsf_context* ctx, repair* r) {
    memset(r, 0, sizeof *r);
    r->multiple = 8;
    r->frames_step = 4;
    CHECK_OK(ctx, gsf_splat_make(ctx, TRUTH, 0, &r->truth));
    CHECK_OK(ctx, gsf_splat_make(ctx, TRUTH, 0, &r->start));
    CHECK_OK(ctx, gsf_splat_make_rasterizer(ctx, &r->rasterizer));
    uint64_t seed = 5;
    for (size_t i = 0; i < TRUTH; i++) {
        for (size_t k = 0; k < 3; k++) {
            r->truth.means[3 * i + k] = (float)test_random_in(&seed, -1.2, 1.2);
            r->start.means[3 * i + k] = r->truth.means[3 * i + k] + (float)test_random_in(&seed, -0.05, 0.05);
            r->truth.log_scales[3 * i + k] = (float)test_random_in(&seed, -2.5, -1.4);
            r->start.log_scales[3 * i + k] = -2.4f;
            r->truth.sh[3 * i + k] = (float)test_random_in(&seed, -1.5, 1.5);
        }
        r->truth.quats[4 * i] = r->start.quats[4 * i] = 1.0f;
        r->truth.opacity_logits[i] = 2.0f;
        r->start.opacity_logits[i] = -1.0f;
    }
    for (int i = 0; i < VIEWS; i++) {
        r->views[i].camera = around(0.5 * i - 0.75, 0.3 * (i % 2) - 0.15);
        r->views[i].image = gsf_wrap_image(r->photos[i], GSF_F32, WIDTH, HEIGHT, 3);
        gsf_render_output out;
        memset(&out, 0, sizeof out);
        out.color = r->views[i].image;
        CHECK_OK(ctx, gsf_splat_render(ctx, r->rasterizer, &r->truth, &r->views[i].camera, NULL, &out));
    }
    r->restorer.struct_size = sizeof r->restorer;
    r->restorer.name = "truth";
    r->restorer.user = r;
    r->restorer.query_fn = repair_query;
    r->restorer.begin_fn = repair_begin;
    r->restorer.restore_fn = repair_restore;
    r->restorer.end_fn = repair_end;
}

static void repair_teardown(gsf_context* ctx, repair* r) {
    gsf_splat_destroy_rasterizer(ctx, r->rasterizer);
    gsf_splat_destroy(ctx, &r->truth);
    gsf_splat_destroy(ctx, &r->start);
}

static gsf_fix_desc repair_desc(void) {
    gsf_fix_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.train.iterations = 120;
    desc.train.seed = 3;
    desc.train.densify_from = 20;
    desc.train.densify_interval = 20;
    desc.rounds = 2;
    desc.windows = 2;
    desc.window_frames = 8; // becomes 9, the nearest 4k + 1
    desc.trajectory = GSF_TRAJ_INTERPOLATE;
    return desc;
}

// Steps until done, at most `stop` times; counts the stages.
static int run_steps(gsf_context* ctx, gsf_fixer* fixer, int stop, int counts[4]) {
    gsf_fix_stats stats;
    for (int i = 0; i < stop; i++) {
        if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) return 1;
        if (counts) counts[stats.stage]++;
        if (stats.stage == GSF_FIX_DONE) return 1;
        if (stats.stage == GSF_FIX_RESTORE)
            CHECK(stats.frame_count == 9 && stats.rendered != NULL && stats.cameras != NULL);
    }
    return 0;
}

typedef struct masked { // checks the references that a restorer receives
    repair* r;
    int32_t needs_depth, begun;
} masked;

static gsf_result masked_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                               gsf_restorer_info* out) {
    (void)ctx; (void)frames; (void)width; (void)height;
    out->frame_count_min = out->frame_count_step = 1;
    out->needs_depth = ((masked*)user)->needs_depth;
    return GSF_OK;
}

static gsf_result masked_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    masked* m = (masked*)user;
    int green = 0, other = 0, deep = 0;
    (void)ctx;
    m->begun++;
    CHECK(count == VIEWS && (references[1].depth.data != NULL) == m->needs_depth);
    for (int i = 0; i < count; i++)
        for (int k = 0; k < PIXELS; k++) {
            const float* color = (const float*)references[i].color.data + 3 * k;
            const float* render = (const float*)references[i].render.data;
            const int hidden = i == 1 && k % WIDTH < WIDTH / 2;
            green += color[0] == 0.0f && color[1] == 1.0f && color[2] == 0.0f;
            other += !hidden && memcmp(color, m->r->photos[i] + 3 * k, 3 * sizeof(float)) != 0;
            if (!m->needs_depth || !hidden) continue;
            other += memcmp(color, render + 3 * k, 3 * sizeof(float)) != 0;
            deep += ((const float*)references[i].depth.data)[k] != 0.0f;
        }
    CHECK(green == 0 && other == 0 && deep == 0);
    return GSF_OK;
}

static gsf_result masked_restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    (void)user; (void)ctx; (void)window;
    return GSF_OK;
}

static void masked_end(void* user, gsf_context* ctx) { (void)user; (void)ctx; }

// In the references passed to a restorer, masked pixels of a photo show the splats' render and have no depth.
static void test_masked_references(gsf_context* ctx) {
    static repair r;
    static uint8_t weight[PIXELS];
    gsf_fix_desc desc = repair_desc();
    repair_setup(ctx, &r);
    for (int k = 0; k < PIXELS; k++) {
        weight[k] = k % WIDTH < WIDTH / 2 ? 0 : 255;
        for (int c = 0; c < 3 && !weight[k]; c++) r.photos[1][3 * k + c] = (float)(c == 1);
    }
    r.views[1].weight = gsf_wrap_image(weight, GSF_U8, WIDTH, HEIGHT, 1);
    for (int needs = 0; needs < 2; needs++) {
        masked m = {&r, needs, 0};
        gsf_restorer restorer = r.restorer;
        gsf_fixer* fixer;
        restorer.user = &m;
        restorer.query_fn = masked_query;
        restorer.begin_fn = masked_begin;
        restorer.end_fn = masked_end;
        restorer.restore_fn = masked_restore;
        desc.rounds = 1;
        desc.first_round = 2;
        if (!CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &restorer, &fixer))) break;
        gsf_fix_stats stats;
        for (int i = 0; i < 8 && !m.begun; i++) CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats));
        CHECK(m.begun == 1);
        gsf_splat_destroy_fixer(ctx, fixer);
    }
    repair_teardown(ctx, &r);
}

static void test_desc(gsf_context* ctx) { // the loop's desc with defaults filled in
    static repair r;
    gsf_fix_desc given, used;
    gsf_fixer* fixer;
    repair_setup(ctx, &r);
    memset(&given, 0, sizeof given);
    given.train.lambda_ssim = -1.0f;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &given, r.views, VIEWS, &r.start, &r.restorer, &fixer));
    used = gsf_splat_get_fixer_desc(fixer);
    CHECK(used.rounds == 3 && used.windows == VIEWS && used.window_frames == 17 && used.lambda == 1.0f);
    CHECK(used.first_round == 9999 && used.last_round == 24999 && used.skip_psnr == 0.0f);
    CHECK(used.train.iterations == 30000 && used.train.lr_means == 1.6e-4f && used.train.lambda_ssim == 0.0f);
    CHECK(used.train.extent > 1.0f && used.train.extent < 4.0f &&
          used.train.render.near_plane == 0.01f * used.train.extent);
    gsf_splat_destroy_fixer(ctx, fixer);
    for (int views = 0; views <= VIEWS + 1; views++) { // the restorer's weight, made for that many photos
        r.also.lambda = views % 2 ? 2.0f : 0.0f;
        r.also.lambda_views = views;
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &given, r.views, VIEWS, &r.start, &r.restorer, &fixer));
        const float share = views == 0 || views > VIEWS ? 1.0f : (float)views / (float)VIEWS;
        CHECK_NEAR(gsf_splat_get_fixer_desc(fixer).lambda, (views % 2 ? 2.0f : 1.0f) * share, 1e-6);
        gsf_splat_destroy_fixer(ctx, fixer);
    }
    given.lambda = -1.0f; // 0
    given.train.iterations = 150; // only one iteration is just before a densification, so rounds stay separate
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &given, r.views, VIEWS, &r.start, &r.restorer, &fixer));
    used = gsf_splat_get_fixer_desc(fixer);
    CHECK(used.first_round == 99 && used.last_round == 125 && used.lambda == 0.0f);
    gsf_splat_destroy_fixer(ctx, fixer);
    given = repair_desc();
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &given, r.views, VIEWS, &r.start, NULL, &fixer));
    used = gsf_splat_get_fixer_desc(fixer);
    CHECK(used.rounds == 0 && used.train.densify_interval == 20); // no restorer
    gsf_splat_destroy_fixer(ctx, fixer);

    // descs that were not zeroed: each canary separately, and a struct full of garbage
    uint32_t* const canaries[] = {&given._start_canary, &given._end_canary, &given.train._start_canary,
                                  &given.train._end_canary, &given.train.render._start_canary,
                                  &given.train.render._end_canary};
    gsf_trainer* trainer;
    static float pixels[3 * PIXELS];
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(pixels, GSF_F32, WIDTH, HEIGHT, 3);
    for (size_t i = 0; i <= sizeof canaries / sizeof *canaries; i++) {
        given = repair_desc();
        if (i < sizeof canaries / sizeof *canaries) *canaries[i] = 1;
        else memset(&given, 0xcd, sizeof given);
        fixer = (gsf_fixer*)&r;
        trainer = (gsf_trainer*)&r;
        CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &given, r.views, VIEWS, &r.start, NULL, &fixer),
                     GSF_ERROR_INVALID_ARGUMENT);
        CHECK(fixer == NULL && strstr(ctx->error, "zeroed"));
        if (i < 2) continue;
        CHECK_RESULT(ctx, gsf_splat_make_trainer(ctx, &given.train, r.views, VIEWS, &r.start, &trainer),
                     GSF_ERROR_INVALID_ARGUMENT);
        CHECK(trainer == NULL && strstr(ctx->error, "zeroed"));
        if (i < 4) continue;
        CHECK_RESULT(ctx, gsf_splat_render(ctx, r.rasterizer, &r.truth, &r.views[0].camera, &given.train.render, &out),
                     GSF_ERROR_INVALID_ARGUMENT);
        CHECK(strstr(ctx->error, "zeroed"));
    }
    repair_teardown(ctx, &r);
}

static double held_out_psnr(gsf_context* ctx, repair* r, gsf_fixer* fixer) {
    static float a[3 * PIXELS], b[3 * PIXELS];
    double sum = 0.0;
    for (int i = 0; i < 3; i++) {
        const gsf_camera camera = around(0.5 * i - 0.5, 0.2);
        gsf_render_output out;
        memset(&out, 0, sizeof out);
        out.color = gsf_wrap_image(a, GSF_F32, WIDTH, HEIGHT, 3);
        CHECK_OK(ctx, gsf_splat_render(ctx, r->rasterizer, &r->truth, &camera, NULL, &out));
        out.color = gsf_wrap_image(b, GSF_F32, WIDTH, HEIGHT, 3);
        CHECK_OK(ctx, gsf_splat_render_trainer(ctx, gsf_splat_get_trainer(fixer), &camera, &out));
        double error = 0.0;
        for (int k = 0; k < 3 * PIXELS; k++) error += pow((double)(a[k] - b[k]), 2.0) / (3.0 * PIXELS);
        sum += -10.0 * log10(error) / 3.0;
    }
    return sum;
}

static int same_splats(gsf_fixer* a, gsf_fixer* b) {
    const gsf_splats *x = gsf_splat_get_trained(gsf_splat_get_trainer(a));
    const gsf_splats *y = gsf_splat_get_trained(gsf_splat_get_trainer(b));
    return x->count == y->count && memcmp(x->means, y->means, 12 * x->count) == 0 &&
           memcmp(x->sh, y->sh, 12 * x->count) == 0 && memcmp(x->opacity_logits, y->opacity_logits, 4 * x->count) == 0;
}

static void test_loop(gsf_context* ctx) {
    static repair r;
    repair_setup(ctx, &r);
    const gsf_fix_desc desc = repair_desc();
    gsf_fixer *plain, *fixed;
    int counts[4] = {0, 0, 0, 0};
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, NULL, &plain));
    CHECK(run_steps(ctx, plain, 1000, counts));
    CHECK(counts[GSF_FIX_TRAIN] == 120 && counts[GSF_FIX_PLAN] == 0 && counts[GSF_FIX_RESTORE] == 0);
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &fixed));
    CHECK(run_steps(ctx, fixed, 1000, counts));
    CHECK(counts[GSF_FIX_TRAIN] == 240 && counts[GSF_FIX_PLAN] == 2 && counts[GSF_FIX_RESTORE] == 4);
    CHECK(r.begun == 2 && r.ended == 2 && r.checked == 4); // the path begins and ends at photos: one in each window
    const double before = held_out_psnr(ctx, &r, plain), after = held_out_psnr(ctx, &r, fixed);
    printf("held-out PSNR: plain %.2f dB, with a perfect restorer %.2f dB\n", before, after);
    CHECK(after > before + 0.3);

    // resume from checkpoints taken every few steps, in all stages
    for (int stop = 1; stop < 126; stop += stop > 38 && stop < 48 ? 1 : 13) {
        gsf_fixer *first, *second;
        gsf_buffer chunks;
        memset(&chunks, 0, sizeof chunks);
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &first));
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &second));
        run_steps(ctx, first, stop, NULL);
        gsf_splat_format_fixer(ctx, first, &chunks);
        gsf_append_last_chunk(ctx, &chunks);
        CHECK(!chunks.failed);
        gsf_splat_destroy_fixer(ctx, first);
        CHECK_OK(ctx, gsf_splat_parse_fixer(ctx, second, "checkpoint", chunks.data, chunks.size));
        CHECK(run_steps(ctx, second, 1000, NULL));
        if (!CHECK(same_splats(fixed, second))) fprintf(stderr, "  resumed after %d steps\n", stop);
        for (size_t cut = 0; cut < chunks.size && stop == 1; cut += chunks.size / 50 + 1)
            CHECK(gsf_splat_parse_fixer(ctx, second, "cut", chunks.data, cut) != GSF_OK);
        gsf_splat_destroy_fixer(ctx, second);
        gsf_destroy_buffer(ctx, &chunks);
    }
    CHECK(r.begun == r.ended);
    gsf_splat_destroy_fixer(ctx, plain);
    gsf_splat_destroy_fixer(ctx, fixed);
    repair_teardown(ctx, &r);
}

// A filter on final renders gives the restorer's frames and changes nothing: a run with calls of it has the same splats.
static void test_restore_views(gsf_context* ctx) {
    static repair r;
    static float color[2][3 * WIDTH * HEIGHT], truth[3 * WIDTH * HEIGHT], confidence[2][WIDTH * HEIGHT];
    gsf_fixer *plain, *filtered, *trained;
    gsf_fix_desc desc = repair_desc();
    repair_setup(ctx, &r);
    r.multiple = r.frames_step = 1;
    desc.train.iterations = 12;
    desc.first_round = 3;
    desc.last_round = 6;
    desc.window_frames = 9;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &plain));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &filtered));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, NULL, &trained));
    const gsf_camera cameras[2] = {around(0.4, 0.1), around(-0.3, 0.0)};
    gsf_image colors[2], confidences[2];
    for (int i = 0; i < 2; i++) {
        colors[i] = gsf_wrap_image(color[i], GSF_F32, WIDTH, HEIGHT, 3);
        confidences[i] = gsf_wrap_image(confidence[i], GSF_F32, WIDTH, HEIGHT, 1);
    }
    int within = 0;
    for (gsf_fix_stats stats = {0}; stats.stage != GSF_FIX_DONE;) {
        const int begun = r.begun;
        const int busy = stats.stage == GSF_FIX_PLAN || (stats.stage == GSF_FIX_RESTORE && stats.window < stats.windows);
        within += busy;
        const gsf_result expected = busy || stats.stage == GSF_FIX_RESTORE ? GSF_ERROR_INVALID_ARGUMENT : GSF_OK;
        CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, &filtered, 1, cameras, 2, colors, confidences), expected);
        CHECK(r.begun - begun <= 1);
        if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, filtered, &stats))) break;
    }
    CHECK(within > 0);
    while (!run_steps(ctx, plain, 1, NULL)) continue;
    CHECK(same_splats(plain, filtered));
    CHECK_OK(ctx, gsf_splat_restore_views(ctx, &filtered, 1, cameras, 2, colors, confidences));
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(truth, GSF_F32, WIDTH, HEIGHT, 3);
    for (int i = 0; i < 2; i++) {
        CHECK_OK(ctx, gsf_splat_render(ctx, r.rasterizer, &r.truth, &cameras[i], NULL, &out));
        CHECK(memcmp(truth, color[i], sizeof truth) == 0 && confidence[i][0] == 0.8f);
    }
    CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, &filtered, 1, cameras, 0, colors, confidences), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, &trained, 1, cameras, 2, colors, confidences), GSF_ERROR_INVALID_ARGUMENT);
    gsf_splat_destroy_fixer(ctx, plain);
    gsf_splat_destroy_fixer(ctx, filtered);
    gsf_splat_destroy_fixer(ctx, trained);
    CHECK(r.begun == r.ended);
    repair_teardown(ctx, &r);
}

// A restorer that adds a grey, another one to the frames of each copy, and refuses to begin twice.
typedef struct tinter { float add[2]; int open, calls; } tinter;

static gsf_result tint_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                             gsf_restorer_info* out) {
    (void)user; (void)ctx; (void)frames; (void)width; (void)height;
    out->frame_count_min = out->frame_count_step = out->width_multiple = out->height_multiple = 1;
    return GSF_OK;
}

static gsf_result tint_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    tinter* t = (tinter*)user;
    (void)references; (void)count;
    if (t->open) return gsf_fail(ctx, GSF_ERROR_RESTORER, "begun twice");
    t->open = 1;
    return GSF_OK;
}

static gsf_result tint_restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    tinter* t = (tinter*)user;
    const float add = t->add[t->calls++ % 2];
    (void)ctx;
    for (int32_t i = 0; i < window->frame_count; i++)
        for (int k = 0; k < PIXELS; k++) {
            for (int c = 0; c < 3; c++)
                ((float*)window->out_color[i].data)[3 * k + c] = ((const float*)window->color[i].data)[3 * k + c] + add;
            ((float*)window->out_confidence[i].data)[k] = add;
        }
    return GSF_OK;
}

static void tint_end(void* user, gsf_context* ctx) {
    (void)ctx;
    ((tinter*)user)->open = 0;
}

static gsf_restorer tint_restorer(const repair* r, tinter* tint) {
    gsf_restorer restorer = r->restorer;
    restorer.user = tint;
    restorer.query_fn = tint_query;
    restorer.begin_fn = tint_begin;
    restorer.restore_fn = tint_restore;
    restorer.end_fn = tint_end;
    return restorer;
}

// Views of several fixers: the mean of what the restorer makes of each one's renders, and the less of it the more this differs
// beyond the renders.
static void test_copies(void) {
    static repair r;
    static float color[2][3 * PIXELS], mean[2][3 * PIXELS], confidence[2][PIXELS], render[2][3 * PIXELS];
    tinter tint = {{0.0f, 0.0f}, 0, 0};
    gsf_fixer *twins[2], *others[2], *plain, *wrong[2];
    gsf_context own, *ctx = &own;
    counter memory = {0};
    memset(&own, 0, sizeof own);
    count_memory(ctx, &memory);
    CHECK_OK(ctx, gsf_init_context(ctx));
    repair_setup(ctx, &r);
    const gsf_restorer restorer = tint_restorer(&r, &tint);
    const gsf_fix_desc desc = repair_desc();
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &restorer, &twins[0]));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &restorer, &twins[1]));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.truth, &restorer, &others[1]));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, NULL, &plain));
    others[0] = wrong[0] = twins[0];
    wrong[1] = plain;
    const gsf_camera cameras[2] = {around(0.4, 0.1), around(-0.3, 0.0)};
    gsf_image colors[2], means[2], confidences[2], renders[2];
    for (int i = 0; i < 2; i++) {
        colors[i] = gsf_wrap_image(color[i], GSF_F32, WIDTH, HEIGHT, 3);
        means[i] = gsf_wrap_image(mean[i], GSF_F32, WIDTH, HEIGHT, 3);
        renders[i] = gsf_wrap_image(render[i], GSF_F32, WIDTH, HEIGHT, 3);
        confidences[i] = gsf_wrap_image(confidence[i], GSF_F32, WIDTH, HEIGHT, 1);
    }
    CHECK_OK(ctx, gsf_splat_restore_views(ctx, twins, 1, cameras, 2, colors, confidences));
    CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, others + 1, 1, cameras, 2, renders, confidences), GSF_ERROR_RESTORER);
    CHECK_OK(ctx, gsf_splat_restore_views(ctx, others, 2, cameras, 2, means, confidences)); // this leaves it closed
    CHECK_OK(ctx, gsf_splat_restore_views(ctx, others + 1, 1, cameras, 2, renders, confidences));
    CHECK_OK(ctx, gsf_splat_restore_views(ctx, others, 2, cameras, 2, means, confidences));
    int differs = 0;
    for (int i = 0; i < 2; i++)
        for (int k = 0; k < 3 * PIXELS; k++) {
            differs += fabsf(color[i][k] - render[i][k]) > 0.05f;
            CHECK_NEAR(mean[i][k], 0.5 * ((double)color[i][k] + (double)render[i][k]), 1e-6);
        }
    CHECK(differs > PIXELS);
    static const float adds[][2] = {{0.2f, 0.2f}, {0.0f, 0.2f}, {0.0f, 0.02f}};
    for (size_t n = 0; n < sizeof adds / sizeof *adds; n++) {
        const double apart = 0.5 * ((double)adds[n][1] - (double)adds[n][0]), middle = (double)adds[n][0] + apart;
        const double share = 1e-4 / (2.0 * apart * apart + 1e-4);
        memcpy(tint.add, adds[n], sizeof tint.add);
        tint.calls = 0;
        CHECK_OK(ctx, gsf_splat_restore_views(ctx, twins, 2, cameras, 2, means, confidences));
        for (int i = 0; i < 2; i++)
            for (int k = 0; k < 3 * PIXELS; k++) {
                CHECK_NEAR(mean[i][k], (double)color[i][k] + share * middle, 2e-6);
                CHECK_NEAR(confidence[i][k / 3], middle, 1e-6);
            }
    }
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    size_t failures = 0;
    memcpy(color, mean, sizeof color);
    memset(mean, 0, sizeof mean);
    for (; result == GSF_ERROR_OUT_OF_MEMORY && failures < 1000; failures++) {
        tint.calls = 0;
        memory.fail_at = memory.calls + 1 + failures;
        result = gsf_splat_restore_views(ctx, twins, 2, cameras, 2, means, confidences);
        memory.fail_at = 0;
    }
    CHECK(result == GSF_OK && failures > 10 && memcmp(color, mean, sizeof color) == 0);
    CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, twins, 0, cameras, 2, means, confidences), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, wrong, 2, cameras, 2, means, confidences), GSF_ERROR_INVALID_ARGUMENT);
    gsf_camera sizes[2] = {cameras[0], cameras[1]};
    sizes[1].height++;
    CHECK_RESULT(ctx, gsf_splat_restore_views(ctx, twins, 2, sizes, 2, means, confidences), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(!tint.open);
    for (int i = 0; i < 2; i++) gsf_splat_destroy_fixer(ctx, twins[i]);
    gsf_splat_destroy_fixer(ctx, others[1]);
    gsf_splat_destroy_fixer(ctx, plain);
    repair_teardown(ctx, &r);
    CHECK(memory.live == 0);
}

// Copies joined: all their splats, together as opaque as those of one copy; a round of what the restorer makes of the copies;
// no growth.
static void test_joined(void) {
    static repair r;
    static float made[16][3 * PIXELS], confidence[16][PIXELS];
    tinter tint = {{0.02f, 0.06f}, 0, 0};
    gsf_fixer *copies[2], *other, *plain, *joined, *again;
    gsf_context own, *ctx = &own;
    counter memory = {0};
    memset(&own, 0, sizeof own);
    count_memory(ctx, &memory);
    CHECK_OK(ctx, gsf_init_context(ctx));
    repair_setup(ctx, &r);
    const gsf_restorer restorer = tint_restorer(&r, &tint);
    gsf_fix_desc desc = repair_desc();
    for (int i = 0; i < 2; i++)
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.truth, &restorer, &copies[i]));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, NULL, &plain));
    gsf_splats linear;
    CHECK_OK(ctx, gsf_splat_make(ctx, TRUTH, 1, &linear));
    for (size_t i = 0; i < TRUTH; i++) linear.quats[4 * i] = 1.0f;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &linear, &restorer, &other));

    desc.train.dropout = 0.5f;
    desc.copies = copies;
    desc.copy_count = 2;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, &restorer, &joined));
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, &restorer, &again));
    const gsf_fix_desc used = gsf_splat_get_fixer_desc(joined);
    CHECK(used.train.iterations == 15 && used.rounds == 1 && used.first_round == 1 && used.train.dropout == 0.0f);
    const gsf_splats* all = gsf_splat_get_trained(gsf_splat_get_trainer(joined));
    CHECK(all->count == 2 * TRUTH);
    for (size_t i = 0; i < 2 * TRUTH; i++) {
        const double passed = 1.0 / (1.0 + exp((double)all->opacity_logits[i]));
        CHECK_NEAR(passed * passed, 1.0 / (1.0 + exp((double)r.truth.opacity_logits[i % TRUTH])), 1e-6);
        CHECK(memcmp(all->means + 3 * i, r.truth.means + 3 * (i % TRUTH), 12) == 0);
        CHECK(memcmp(all->sh + 3 * i, r.truth.sh + 3 * (i % TRUTH), 12) == 0);
    }

    int stages[4] = {0}, windows = 0;
    gsf_fix_stats stats;
    gsf_buffer chunks = {0};
    do {
        if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, joined, &stats))) break;
        stages[stats.stage]++;
        if (stats.stage == GSF_FIX_TRAIN && stats.train.iteration == 9) {
            gsf_splat_format_fixer(ctx, joined, &chunks);
            gsf_append_last_chunk(ctx, &chunks);
        }
        if (stats.stage != GSF_FIX_RESTORE) continue;
        gsf_image colors[16], confidences[16];
        CHECK(stages[GSF_FIX_TRAIN] == 1 && stats.restored != NULL && stats.frame_count <= 16);
        for (int32_t i = 0; i < stats.frame_count; i++) {
            const gsf_camera* c = stats.cameras + i;
            colors[i] = gsf_wrap_image(made[i], GSF_F32, c->width, c->height, 3);
            confidences[i] = gsf_wrap_image(confidence[i], GSF_F32, c->width, c->height, 1);
        }
        CHECK_OK(ctx, gsf_splat_restore_views(ctx, copies, 2, stats.cameras, (size_t)stats.frame_count, colors, confidences));
        for (int32_t i = 0; i < stats.frame_count; i++)
            CHECK(memcmp(made[i], stats.restored[i].data, sizeof made[i]) == 0);
        windows++;
    } while (stats.stage != GSF_FIX_DONE);
    CHECK(stages[GSF_FIX_TRAIN] == 15 && windows == 2 && all->count == 2 * TRUTH && !tint.open);
    CHECK_OK(ctx, gsf_splat_parse_fixer(ctx, again, "joined", chunks.data, chunks.size));
    while (!run_steps(ctx, again, 1, NULL)) continue;
    CHECK(same_splats(again, joined));
    gsf_destroy_buffer(ctx, &chunks);
    gsf_splat_destroy_fixer(ctx, again);

    desc.copy_count = 1; // without a restorer, copies may have none either
    desc.copies = &plain;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, NULL, &again));
    CHECK(gsf_splat_get_fixer_desc(again).rounds == 0 && run_steps(ctx, again, 16, NULL));
    gsf_splat_destroy_fixer(ctx, again);
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, &restorer, &again), GSF_ERROR_INVALID_ARGUMENT);
    gsf_fixer* const unlike[2] = {copies[0], other};
    desc.copies = unlike;
    desc.copy_count = 2;
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, &restorer, &again), GSF_ERROR_INVALID_ARGUMENT);
    desc.copies = NULL;
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, &restorer, &again), GSF_ERROR_INVALID_ARGUMENT);
    desc.copies = copies;
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    size_t failures = 0;
    for (; result == GSF_ERROR_OUT_OF_MEMORY && failures < 1000; failures++) {
        memory.fail_at = memory.calls + 1 + failures;
        result = gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, NULL, &restorer, &again);
        memory.fail_at = 0;
    }
    CHECK(result == GSF_OK && failures > 10);
    gsf_splat_destroy_fixer(ctx, again);
    gsf_splat_destroy_fixer(ctx, joined);
    for (int i = 0; i < 2; i++) gsf_splat_destroy_fixer(ctx, copies[i]);
    gsf_splat_destroy_fixer(ctx, other);
    gsf_splat_destroy_fixer(ctx, plain);
    gsf_splat_destroy(ctx, &linear);
    repair_teardown(ctx, &r);
    CHECK(memory.live == 0);
}

// Whether a path is possible is checked before any training: a rig with parallel axes is accepted; coincident cameras are
// refused immediately, unless no rounds are requested.
static void test_rigs(gsf_context* ctx) {
    for (int rig = 0; rig < 2; rig++) {
        static repair r;
        repair_setup(ctx, &r);
        gsf_fix_desc desc = repair_desc();
        desc.trajectory = GSF_TRAJ_REFERENCE;
        for (int i = 0; i < VIEWS; i++) {
            gsf_camera c = around(0.0, 0.0);
            double pose[16];
            gsf_get_camera_c2w(&c, pose);
            if (!rig) pose[12] += 0.3 * i - 0.45;
            const double eye[3] = {pose[12], pose[13], pose[14]}, up[3] = {0, -1, 0}, turn = rig ? 0.2 * i : 0.0;
            const double target[3] = {eye[0] + sin(turn), eye[1], eye[2] + cos(turn)};
            CHECK_OK(ctx, gsf_traj_look_at(ctx, eye, target, up, pose));
            gsf_set_camera_c2w(&c, pose);
            r.views[i].camera = c;
        }
        gsf_fixer* fixer = NULL;
        const gsf_result made = gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &fixer);
        CHECK(made == (rig ? GSF_ERROR_DEGENERATE : GSF_OK)); // rotated in place
        gsf_fix_stats now;
        memset(&now, 0, sizeof now);
        while (fixer && now.stage != GSF_FIX_DONE)
            if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &now))) break;
        gsf_splat_destroy_fixer(ctx, fixer);
        desc.rounds = -1;
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, NULL, &fixer));
        gsf_splat_destroy_fixer(ctx, fixer);
        repair_teardown(ctx, &r);
    }
}

// A given path is used in every round: its poses in order, distributed over the frames, with the first photo's camera.
static void test_given_path(gsf_context* ctx) {
    static const size_t counts[] = {1, 5, 18, 40}; // of 18 frames
    static repair r;
    gsf_camera path[40];
    repair_setup(ctx, &r);
    gsf_fix_desc desc = repair_desc();
    desc.train.iterations = 24;
    desc.path = path;
    for (int i = 0; i < 40; i++) {
        path[i] = around(0.03 * i - 0.6, 0.1);
        path[i].width /= 2; // differs from the frames' width
    }
    for (size_t k = 0; k < sizeof counts / sizeof *counts; k++) {
        desc.path_count = counts[k];
        gsf_fixer* fixer = NULL;
        gsf_fix_stats now;
        memset(&now, 0, sizeof now);
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &fixer));
        size_t frames = 0, last = 0, jumps = 0, wrong = 0;
        while (fixer && now.stage != GSF_FIX_DONE) {
            if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &now))) break;
            for (int i = 0; i < (now.stage == GSF_FIX_RESTORE ? now.frame_count : 0); i++, frames++) {
                const gsf_camera* camera = now.cameras + i;
                size_t at = 0;
                while (at < counts[k] && memcmp(path[at].w2c, camera->w2c, sizeof camera->w2c) != 0) at++;
                wrong += at == counts[k] || now.reference_index[i] != -1 || camera->width != WIDTH ||
                         camera->fx != r.views[0].camera.fx;
                if (frames % 18 == 0) last = at; // first frame of a round
                wrong += at < last;
                jumps += at != last;
                last = at;
            }
        }
        CHECK(frames == 2 * 18 && wrong == 0);
        CHECK(jumps == 2 * ((counts[k] < 18 ? counts[k] : 18) - 1));
        gsf_splat_destroy_fixer(ctx, fixer);
    }
    gsf_fixer* fixer = NULL; // one photo: the path must be given
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, 1, &r.start, &r.restorer, &fixer));
    gsf_splat_destroy_fixer(ctx, fixer);
    desc.path_count = 0;
    CHECK(gsf_splat_make_fixer(ctx, &desc, r.views, 1, &r.start, &r.restorer, &fixer) == GSF_ERROR_DEGENERATE);
    CHECK(strstr(ctx->error, "one photo") != NULL);
    desc.path_count = 40;
    path[3].fx = -1.0;
    CHECK(gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &fixer) != GSF_OK && !fixer);
    desc.path = NULL;
    CHECK(gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &fixer) == GSF_ERROR_INVALID_ARGUMENT);
    repair_teardown(ctx, &r);
}

// Restorers trained for 13 frames of 96 x 40, with photos of 48 x 40. Kind 0 squashes the photos to the frame; 1 does so
// at a lower pixel limit, as --quality fast sets; 2 and 3 need square pixels in frames of one size, half of which is margin
// and excluded from training; 4 prefers frames of half the photos' size, 5 too, but the host wants them whole.
static void test_native_frames(gsf_context* ctx) {
    static repair r;
    gsf_fixer* fixer;
    gsf_fix_stats stats;
    for (int kind = 0; kind < 6; kind++) {
        repair_setup(ctx, &r);
        gsf_fix_desc desc = repair_desc();
        desc.window_frames = 0;
        desc.train.iterations = 90;
        desc.rounds = 1;
        r.multiple = kind >= 3 ? 1 : 8;
        r.also.frame_count = r.also.frame_count_max = 13;
        r.also.width = 96;
        r.also.height = 40;
        r.also.squash = kind < 2;
        if (kind == 1) desc.max_pixels = 1100; // an exact fit would be 51 x 21
        if (kind >= 2) r.also.width_max = 96, r.also.height_max = 40;
        if (kind >= 4) r.also.frame_scale = 0.5f;
        if (kind == 5) desc.frame_scale = 1.0f;
        if (kind == 2) r.multiple = 40, r.also.width_max = 120, desc.max_pixels = 100; // would shrink photos to a corner
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &fixer));
        CHECK(gsf_splat_get_fixer_desc(fixer).window_frames == 13);
        CHECK(gsf_splat_get_fixer_desc(fixer).frame_scale == (kind == 4 ? 0.5f : 1.0f));
        int windows = 0, wrong = 0;
        for (stats.stage = GSF_FIX_TRAIN; stats.stage != GSF_FIX_DONE;) {
            if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) break;
            if (stats.stage != GSF_FIX_RESTORE) continue;
            windows++;
            CHECK(stats.frame_count == 13);
            const gsf_camera* c = stats.cameras;
            if (kind == 0) CHECK(c->width == 96 && c->height == 40);
            if (kind == 1) CHECK(c->width == 48 && c->height == 24);
            if (kind == 2) CHECK(c->width == 40 && c->height == 40);
            if (kind == 3 || kind == 5) CHECK(c->width == 48 && c->height == 40 && c->fx == r.views[0].camera.fx);
            if (kind == 4) CHECK(c->width == 24 && c->height == 20 && c->fx == 0.5 * r.views[0].camera.fx);
            const float reach = 0.5f * (float)WIDTH * (float)(c->fx / r.views[0].camera.fx);
            const float rise = 0.5f * (float)HEIGHT * (float)(c->fy / r.views[0].camera.fy);
            for (int y = 0; y < c->height; y++)
                for (int x = 0; x < c->width; x++) {
                    const float confidence = ((const float*)stats.confidence[1].data)[y * c->width + x];
                    const int inside = fabsf((float)x + 0.5f - 0.5f * (float)c->width) <= reach + 1e-3f &&
                                       fabsf((float)y + 0.5f - 0.5f * (float)c->height) <= rise + 1e-3f;
                    wrong += confidence != (inside ? 0.8f : 0.0f);
                }
        }
        CHECK(windows == 2 && wrong == 0);
        gsf_splat_destroy_fixer(ctx, fixer);
        repair_teardown(ctx, &r);
    }
}

static void test_trouble(gsf_context* ctx) {
    static repair r;
    repair_setup(ctx, &r);
    gsf_fix_desc desc = repair_desc();
    gsf_fixer *calm, *rough;
    gsf_fix_stats stats;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &calm));
    CHECK(run_steps(ctx, calm, 1000, NULL));
    // a restorer that fails once, and a cancellation in between, do not change the final result
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough));
    r.windows = 0;
    r.fail_at = 2;
    int errors = 0, cancels = 0, steps = 0;
    for (stats.stage = GSF_FIX_TRAIN; stats.stage != GSF_FIX_DONE && steps < 1000; steps++) {
        if (steps == 30 || steps == 43) gsf_request_cancel(ctx);
        const gsf_result result = gsf_splat_step_fixer(ctx, rough, &stats);
        if (result == GSF_ERROR_CANCELLED) {
            cancels++;
            gsf_clear_cancel(ctx);
        } else if (result != GSF_OK) {
            CHECK(result == GSF_ERROR_RESTORER && strstr(ctx->error, "out of ideas"));
            errors++;
        }
    }
    CHECK(errors == 1 && cancels == 2);
    CHECK(same_splats(calm, rough));
    gsf_splat_destroy_fixer(ctx, rough);
    r.fail_at = 0;
    // with a very low threshold, every window agrees with the references and is skipped
    desc.skip_psnr = 1.0f;
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough));
    r.checked = 0;
    for (stats.stage = GSF_FIX_TRAIN, steps = 0; stats.stage != GSF_FIX_DONE && steps < 1000; steps++)
        CHECK_OK(ctx, gsf_splat_step_fixer(ctx, rough, &stats));
    printf("%d of 4 windows skipped\n", (int)stats.skipped);
    CHECK(stats.skipped > 0 && r.checked == 4 - stats.skipped);
    gsf_splat_destroy_fixer(ctx, rough);
    gsf_splat_destroy_fixer(ctx, calm);
    // bad descriptions
    desc.window_frames = 1;
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough),
                 GSF_ERROR_INVALID_ARGUMENT);
    desc = repair_desc();
    desc.first_round = 1000;
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough),
                 GSF_ERROR_INVALID_ARGUMENT);
    for (int i = 0; i < 3; i++) {
        desc = repair_desc();
        desc.frame_scale = i == 0 ? -0.5f : i == 1 ? 1.01f : NAN;
        CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough),
                     GSF_ERROR_INVALID_ARGUMENT);
    }
    desc = repair_desc();
    desc.warp_weight = NAN;
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough),
                 GSF_ERROR_INVALID_ARGUMENT);
    desc = repair_desc();
    r.restorer.end_fn = NULL;
    CHECK_RESULT(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &rough),
                 GSF_ERROR_INVALID_ARGUMENT);
    repair_teardown(ctx, &r);
}

static int saves_as(gsf_context* ctx, const gsf_fixer* fixer, const gsf_buffer* expected) {
    gsf_buffer chunks;
    memset(&chunks, 0, sizeof chunks);
    gsf_splat_format_fixer(ctx, fixer, &chunks);
    gsf_append_last_chunk(ctx, &chunks);
    const int same = chunks.size == expected->size && memcmp(chunks.data, expected->data, chunks.size) == 0;
    gsf_destroy_buffer(ctx, &chunks);
    return same;
}

// If loading a checkpoint runs out of memory, the loop is unchanged. If planning the round fails after a load, the next
// step plans it.
static void test_failed_restore(void) {
    static repair r;
    gsf_context ctx;
    counter memory = {0};
    memset(&ctx, 0, sizeof ctx);
    count_memory(&ctx, &memory);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    repair_setup(&ctx, &r);
    const gsf_fix_desc desc = repair_desc();
    gsf_fixer *whole, *first, *second;
    gsf_fix_stats stats;
    gsf_buffer untouched = {0}, chunks = {0};
    CHECK_OK(&ctx, gsf_splat_make_fixer(&ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &whole));
    CHECK(run_steps(&ctx, whole, 1000, NULL));
    CHECK_OK(&ctx, gsf_splat_make_fixer(&ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &first));
    for (int round = 0; round < 2;) { // frames of the first round are trained on, the second is being restored
        CHECK_OK(&ctx, gsf_splat_step_fixer(&ctx, first, &stats));
        round = stats.stage == GSF_FIX_RESTORE ? stats.round : 0;
    }
    const int calls = (int)memory.calls;
    gsf_splat_format_fixer(&ctx, first, &chunks);
    gsf_append_last_chunk(&ctx, &chunks);
    CHECK((int)memory.calls - calls <= 2); // the buffer at its full size, and pixels of a frame: never two buffers
    CHECK(chunks.capacity <= chunks.size + chunks.size / 15 + 8192);
    gsf_splat_destroy_fixer(&ctx, first);
    CHECK_OK(&ctx, gsf_splat_make_fixer(&ctx, &desc, r.views, VIEWS, &r.start, &r.restorer, &second));
    gsf_splat_format_fixer(&ctx, second, &untouched);
    gsf_append_last_chunk(&ctx, &untouched);
    CHECK(!chunks.failed && !untouched.failed);
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    size_t failures = 0;
    for (; result == GSF_ERROR_OUT_OF_MEMORY && failures < 1000; failures++) {
        memory.fail_at = memory.calls + 1 + failures;
        result = gsf_splat_parse_fixer(&ctx, second, "checkpoint", chunks.data, chunks.size);
        memory.fail_at = 0;
        if (result != GSF_OK && !CHECK(saves_as(&ctx, second, &untouched))) break;
    }
    CHECK(result == GSF_OK && failures > 10 && saves_as(&ctx, second, &chunks));
    memory.fail_at = memory.calls + 1;
    CHECK_RESULT(&ctx, gsf_splat_step_fixer(&ctx, second, &stats), GSF_ERROR_OUT_OF_MEMORY);
    memory.fail_at = 0;
    CHECK(run_steps(&ctx, second, 1000, NULL) && same_splats(whole, second));
    gsf_splat_destroy_fixer(&ctx, second);
    gsf_splat_destroy_fixer(&ctx, whole);
    gsf_destroy_buffer(&ctx, &untouched);
    gsf_destroy_buffer(&ctx, &chunks);
    repair_teardown(&ctx, &r);
    CHECK(memory.live == 0);
}

// The start is the ground truth, so photos 0 and 1 match their renders. Photos 2 and 3 each show something else: the
// references do not explain what lies between them.
static void mixed_setup(gsf_context* ctx, repair* r) {
    repair_setup(ctx, r);
    uint64_t seed = 11;
    for (int i = 2; i < VIEWS; i++)
        for (int k = 0; k < 3 * PIXELS; k++) r->photos[i][k] = (float)test_random(&seed);
    gsf_splat_destroy(ctx, &r->start);
    r->start = r->truth;
}

// Number of frames in the checkpoint's chunk `tag` (layout: above gsf__open_frames).
static uint64_t frames_in(const gsf_buffer* chunks, const char* tag) {
    gsf_chunk chunk;
    uint64_t count = 0;
    if (!CHECK(gsf_find_chunk(chunks->data, chunks->size, tag, &chunk) && chunk.size >= 8)) return 0;
    for (int i = 7; i >= 0; i--) count = count << 8 | ((const unsigned char*)chunk.data)[i];
    return count;
}

// One run of mixed_setup's scene: two rounds of four windows of 9 frames, of which the first `skips` are skipped in
// each. resumed: every window is followed by a checkpoint and a new fixer that continues from it.
static gsf_fixer* run_mixed(gsf_context* ctx, repair* r, float skip_psnr, int skips, int resumed) {
    gsf_fix_desc desc = repair_desc();
    gsf_fixer *fixer, *next;
    gsf_fix_stats stats;
    gsf_buffer chunks;
    desc.windows = 4;
    desc.train.iterations = 12;
    desc.first_round = 3;
    desc.last_round = 6;
    desc.skip_psnr = skip_psnr;
    r->restored = r->checked = 0;
    memset(&chunks, 0, sizeof chunks);
    CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r->views, VIEWS, &r->start, &r->restorer, &fixer));
    uint64_t pending = 0;
    int skipped = 0, windows = 0;
    for (stats.stage = GSF_FIX_TRAIN; stats.stage != GSF_FIX_DONE;) {
        if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) break;
        if (stats.stage != GSF_FIX_RESTORE) continue;
        const int skip = stats.window <= skips;
        windows++;
        skipped += skip;
        CHECK(stats.skipped == skipped && (stats.restored == NULL) == skip && (stats.confidence == NULL) == skip);
        CHECK(stats.frame_count == 9 && stats.rendered != NULL);
        pending = stats.window == 1 ? 0 : pending;
        for (int i = 0; i < stats.frame_count; i++) pending += !skip && stats.reference_index[i] < 0;
        if (!resumed) continue;
        chunks.size = 0;
        gsf_splat_format_fixer(ctx, fixer, &chunks);
        gsf_append_last_chunk(ctx, &chunks);
        CHECK(!chunks.failed && frames_in(&chunks, "FIXP") == pending);
        gsf_splat_destroy_fixer(ctx, fixer);
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r->views, VIEWS, &r->start, &r->restorer, &next));
        CHECK_OK(ctx, gsf_splat_parse_fixer(ctx, next, "checkpoint", chunks.data, chunks.size));
        fixer = next;
    }
    CHECK(windows == 8 && r->restored == 8 - 2 * skips);
    chunks.size = 0;
    gsf_splat_format_fixer(ctx, fixer, &chunks);
    CHECK(frames_in(&chunks, "FIXA") == pending); // only the second round's restored frames are trained on
    gsf_destroy_buffer(ctx, &chunks);
    return fixer;
}

// A frame of the first window by a restorer that prefers a weight of `warp`, with that of the desc.
static void mixed_frame(gsf_context* ctx, repair* r, float preferred, float weight, float skip_psnr, float* color,
                        float* confidence) {
    enum { FRAME = 4 };
    gsf_fix_desc desc = repair_desc();
    gsf_fixer* fixer;
    gsf_fix_stats stats;
    desc.train.iterations = 12;
    desc.rounds = 1;
    desc.first_round = desc.last_round = 3;
    desc.skip_psnr = skip_psnr;
    desc.warp_weight = weight;
    r->also.warp_weight = preferred;
    if (!CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r->views, VIEWS, &r->start, &r->restorer, &fixer))) return;
    for (stats.stage = GSF_FIX_TRAIN; stats.stage != GSF_FIX_RESTORE;)
        if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixer, &stats))) break;
    if (CHECK(stats.stage == GSF_FIX_RESTORE && stats.restored && stats.restored[FRAME].width == WIDTH &&
              stats.restored[FRAME].height == HEIGHT)) {
        memcpy(color, stats.restored[FRAME].data, 3 * PIXELS * sizeof *color);
        memcpy(confidence, stats.confidence[FRAME].data, PIXELS * sizeof *confidence);
    }
    gsf_splat_destroy_fixer(ctx, fixer);
}

// Frames of `warp` are mixed into the restorer's, by weight and confidence.
static void test_mixed_warp(gsf_context* ctx) {
    static const struct { float preferred, weight, skip_psnr, used; } cases[] = {
        {0.25f, 0.0f, 0.0f, 0.25f}, {0.25f, 0.0f, 100.0f, 0.25f}, {0.25f, 2.0f, 0.0f, 2.0f}, {0.25f, -1.0f, 100.0f, 0.0f},
    };
    static repair r;
    static float own[4 * PIXELS], warped[4 * PIXELS], out[4 * PIXELS]; // colours, then confidences
    repair_setup(ctx, &r);
    mixed_frame(ctx, &r, 0.0f, 0.0f, 0.0f, own, own + 3 * PIXELS);
    mixed_frame(ctx, &r, 0.0f, 1e6f, 0.0f, warped, warped + 3 * PIXELS);
    int known = 0, sure = 0, differ = 0;
    for (int i = 0; i < PIXELS; i++) {
        known += warped[3 * PIXELS + i] > 0.01f;
        sure += warped[3 * PIXELS + i] > 0.99f;
        differ += fabsf(warped[3 * i] - own[3 * i]) > 0.02f;
        CHECK(own[3 * PIXELS + i] == 0.8f);
    }
    printf("warp: %d of %d pixels known, %d surely, %d unlike the truth\n", known, PIXELS, sure, differ);
    CHECK(known > PIXELS / 4 && sure < known / 2 && differ > PIXELS / 20);
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        const float w = cases[k].used;
        double worst = 0.0;
        mixed_frame(ctx, &r, cases[k].preferred, cases[k].weight, cases[k].skip_psnr, out, out + 3 * PIXELS);
        for (int i = 0; i < PIXELS; i++) {
            const float part = w * warped[3 * PIXELS + i], sum = 0.8f + part;
            worst = fmax(worst, fabs((double)(out[3 * PIXELS + i] - sum / (1.0f + w))));
            for (int c = 3 * i; c < 3 * i + 3; c++)
                worst = fmax(worst, fabs((double)(out[c] - (0.8f * own[c] + part * warped[c]) / sum)));
        }
        CHECK_NEAR(worst, 0.0, 1e-5);
        if (w == 0.0f) CHECK(memcmp(out, own, sizeof own) == 0);
    }
    repair_teardown(ctx, &r);
}

static void test_mixed_windows(gsf_context* ctx) {
    static repair r;
    mixed_setup(ctx, &r);
    gsf_fixer* all = run_mixed(ctx, &r, 0.0f, 0, 0);
    CHECK(r.checked == 4); // the photos at both ends of the path
    gsf_fixer* some = run_mixed(ctx, &r, 22.0f, 2, 0); // the windows agree to 27 and 26 dB, then 19 and 12
    CHECK(r.checked == 2); // only the second end's window is restored
    gsf_fixer* resumed = run_mixed(ctx, &r, 22.0f, 2, 1);
    CHECK(same_splats(some, resumed) && !same_splats(some, all));
    gsf_splat_destroy_fixer(ctx, all);
    gsf_splat_destroy_fixer(ctx, some);
    gsf_splat_destroy_fixer(ctx, resumed);
    memset(&r.start, 0, sizeof r.start); // shares the arrays of r.truth
    repair_teardown(ctx, &r);
}

// A host's restorer that delegates to warp: the loop treats it according to what its query reports, nothing else.
typedef struct wrapped { gsf_restorer warp; int hides, begun, restored; } wrapped;

static gsf_result wrapped_query(void* user, gsf_context* ctx, int32_t frames, int32_t width, int32_t height,
                                gsf_restorer_info* out) {
    const wrapped* w = (const wrapped*)user;
    const gsf_result result = w->warp.query_fn(w->warp.user, ctx, frames, width, height, out);
    CHECK(out->explains);
    if (w->hides) out->explains = 0;
    return result;
}
static gsf_result wrapped_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    wrapped* w = (wrapped*)user;
    w->begun++;
    return w->warp.begin_fn(w->warp.user, ctx, references, count);
}
static gsf_result wrapped_restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    wrapped* w = (wrapped*)user;
    w->restored++;
    return w->warp.restore_fn(w->warp.user, ctx, window);
}
static void wrapped_end(void* user, gsf_context* ctx) { ((wrapped*)user)->warp.end_fn(((wrapped*)user)->warp.user, ctx); }

static void test_explaining_restorer(gsf_context* ctx) {
    static repair r;
    wrapped all[3];
    gsf_restorer outer[3]; // borrowed by the fixers
    gsf_fixer* fixers[3];
    memset(all, 0, sizeof all);
    mixed_setup(ctx, &r);
    gsf_fix_desc desc = repair_desc();
    desc.windows = 4;
    desc.train.iterations = 12;
    desc.first_round = 3;
    desc.last_round = 6;
    desc.skip_psnr = 22.0f; // two of the four windows agree and are skipped, in each of the two rounds
    for (int i = 0; i < 3; i++) { // a wrapper that reports `explains`; one that does not; warp itself
        wrapped* w = all + i;
        const gsf_restorer host = {sizeof host, "wrapped", w, wrapped_query, wrapped_begin, wrapped_restore, wrapped_end, NULL};
        const gsf_restorer* used = i == 2 ? &w->warp : &outer[i];
        outer[i] = host;
        CHECK_OK(ctx, gsf_splat_make_warp(ctx, &w->warp));
        w->hides = i == 1;
        CHECK_OK(ctx, gsf_splat_make_fixer(ctx, &desc, r.views, VIEWS, &r.start, used, &fixers[i]));
        int skipped = 0;
        for (gsf_fix_stats stats = {0}; stats.stage != GSF_FIX_DONE; skipped = stats.skipped)
            if (!CHECK_OK(ctx, gsf_splat_step_fixer(ctx, fixers[i], &stats))) break;
        CHECK(skipped == 4);
        CHECK(w->begun == (i < 2 ? 2 : 0) && w->restored == (i == 0 ? 8 : i == 1 ? 4 : 0)); // all windows; those to repair
        CHECK(same_splats(fixers[0], fixers[i]));
    }
    for (int i = 0; i < 3; i++) {
        gsf_splat_destroy_fixer(ctx, fixers[i]);
        gsf_destroy_restorer(ctx, &all[i].warp);
    }
    memset(&r.start, 0, sizeof r.start); // shares the arrays of r.truth
    repair_teardown(ctx, &r);
}

static void test_seen_mask(gsf_context* ctx) {
    static repair r;
    static uint8_t seen[PIXELS], all[PIXELS];
    repair_setup(ctx, &r);
    const gsf_camera novel = around(0.1, 0.0);
    gsf_camera cameras[VIEWS];
    for (int i = 0; i < VIEWS; i++) cameras[i] = r.views[i].camera;
    gsf_image mask = gsf_wrap_image(seen, GSF_U8, WIDTH, HEIGHT, 1),
              full = gsf_wrap_image(all, GSF_U8, WIDTH, HEIGHT, 1);
    CHECK_OK(ctx, gsf_splat_render_seen_mask(ctx, &r.truth, &novel, cameras, VIEWS, &full));
    CHECK_OK(ctx, gsf_splat_render_seen_mask(ctx, &r.truth, &novel, &novel, 1, &mask)); // sees all of its own view
    int self = 0, more = 0, covered = 0;
    static float alpha[PIXELS];
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.alpha = gsf_wrap_image(alpha, GSF_F32, WIDTH, HEIGHT, 1);
    CHECK_OK(ctx, gsf_splat_render(ctx, r.rasterizer, &r.truth, &novel, NULL, &out));
    for (int i = 0; i < PIXELS; i++) {
        covered += alpha[i] >= 0.5f;
        self += seen[i] == 1;
        more += all[i] == 1;
        CHECK(seen[i] <= 1 && all[i] <= 1 && (alpha[i] >= 0.5f || !(seen[i] | all[i])));
    }
    CHECK(self == covered && more <= covered && more > covered / 2);
    CHECK_OK(ctx, gsf_splat_render_seen_mask(ctx, &r.truth, &novel, NULL, 0, &mask));
    for (int i = 0; i < PIXELS; i++) CHECK(seen[i] == 0);
    repair_teardown(ctx, &r);
}

int main(void) {
    gsf_context ctx;
    memset(&ctx, 0, sizeof ctx);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    test_warp(&ctx);
    test_warp_residual(&ctx);
    test_warp_bytes(&ctx);
    test_warp_refutes(&ctx);
    test_seen_mask(&ctx);
    test_desc(&ctx);
    test_masked_references(&ctx);
    test_mixed_warp(&ctx);
    test_mixed_windows(&ctx);
    test_explaining_restorer(&ctx);
    test_loop(&ctx);
    test_restore_views(&ctx);
    test_copies();
    test_joined();
    test_rigs(&ctx);
    test_given_path(&ctx);
    test_native_frames(&ctx);
    test_trouble(&ctx);
    test_failed_restore();
    return test_report();
}
