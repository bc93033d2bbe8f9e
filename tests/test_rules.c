// test_rules.c - rules with a numeric threshold, each tried on both sides of it: a wrong number would cost quality
// without making any other test fail.
// gcc -O2 -std=c11 -I. -Itests tests/test_rules.c -lm
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"
#include "test.h"

// ---- the repair loop -----------------------------------------------------------

// The restored views' weight rises from 0 at the first round to lambda at the end as t (2 - t).
static void test_restored_weight(void) {
    static const struct { int32_t iteration; double t; } cases[] = {
        {0, 0.0}, {400, 0.0}, {500, 0.125}, {600, 0.25}, {800, 0.5}, {1000, 0.75}, {1200, 1.0}, {1300, 1.0}};
    gsf_trainer trainer;
    gsf_fixer fixer;
    memset(&trainer, 0, sizeof trainer);
    memset(&fixer, 0, sizeof fixer);
    fixer.trainer = &trainer;
    fixer.desc.lambda = 0.6f;
    fixer.desc.first_round = 400;
    fixer.desc.train.iterations = 1200;
    for (size_t i = 0; i < GSF__COUNT(cases); i++) {
        const double t = cases[i].t;
        trainer.iteration = cases[i].iteration;
        CHECK_NEAR(gsf__restored_weight(&fixer), 0.6 * (2.0 * t - t * t), 1e-6);
    }
    fixer.desc.first_round = 1200; // no span to rise over
    CHECK_NEAR(gsf__restored_weight(&fixer), 0.6, 1e-7);
}

// A step's weight is 0 or the full one, and in every stretch of 100 steps their mean is the scheduled weight.
static void test_restored_step_weight(void) {
    static const float lambdas[] = {0.3f, 1.0f, 2.0f};
    gsf_trainer trainer;
    gsf_fixer fixer;
    memset(&trainer, 0, sizeof trainer);
    memset(&fixer, 0, sizeof fixer);
    fixer.trainer = &trainer;
    for (size_t i = 0; i < GSF__COUNT(lambdas); i++) {
        const float full = lambdas[i] > 1.0f ? lambdas[i] : 1.0f;
        fixer.desc.lambda = lambdas[i];
        for (int part = 0; part <= 20; part++) {
            const float weight = lambdas[i] * (float)part / 20.0f;
            for (int32_t first = 0; first < 30000; first += 4999) {
                double sum = 0.0;
                for (trainer.iteration = first; trainer.iteration < first + 100; trainer.iteration++) {
                    const float step = gsf__restored_step_weight(&fixer, weight);
                    CHECK(step == 0.0f || step == full);
                    sum += (double)step;
                }
                CHECK_NEAR(sum / 100.0, (double)weight, 0.0201 * (double)full); // two steps off at most
                if (part == 0 || weight == full) CHECK(sum == 100.0 * (double)weight);
            }
        }
    }
}

// ---- densification -------------------------------------------------------------

static gsf__model make_model(gsf_context* ctx, size_t count) {
    gsf__model model;
    memset(&model, 0, sizeof model);
    if (!CHECK_OK(ctx, gsf__model_reserve(ctx, &model, count))) exit(2);
    model.count = count;
    return model;
}

// Photos and restored views have separate means, of which the larger one decides: many visits of one kind do not dilute
// the gradients of a few of the other.
static void test_densify_means(gsf_context* ctx) {
    enum { COUNT = 5 };
    static const struct { float sum[2]; uint32_t visits[2]; float mean; int grows; } cases[COUNT] = {
        {{3e-3f, 0.0f}, {10, 0}, 3e-4f, 1},     // photos only
        {{0.0f, 3e-3f}, {0, 10}, 3e-4f, 1},     // restored views only
        {{3e-3f, 1e-3f}, {10, 90}, 3e-4f, 1},   // 4e-5 if averaged together
        {{1e-3f, 3e-3f}, {90, 10}, 3e-4f, 1},
        {{1e-3f, 1.5e-3f}, {10, 10}, 1.5e-4f, 0}}; // their sum would exceed the threshold
    gsf__model model = make_model(ctx, COUNT);
    for (size_t i = 0; i < COUNT; i++) {
        for (int k = 0; k < 2; k++) {
            model.grad_sum[k][i] = cases[i].sum[k];
            model.visits[k][i] = cases[i].visits[k];
        }
        CHECK_NEAR(gsf__densify_mean_grad(&model, i), cases[i].mean, 1e-9);
    }
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.grad = 2e-4f;
    rule.clone_scale = 10.0;
    rule.max_splats = 100;
    size_t clones, splits;
    gsf__densify_select(&model, &rule, &clones, &splits);
    for (size_t i = 0; i < COUNT; i++) CHECK((model.action[i] == GSF__CLONE) == cases[i].grows);
    CHECK(clones == 4 && splits == 0);
    gsf__model_destroy(ctx, &model);
}

// A step adds to two sums: one for each kind of view.
static void test_visits(gsf_context* ctx) {
    gsf__model model = make_model(ctx, 2);
    gsf__visit_job job;
    memset(&job, 0, sizeof job);
    job.model = &model;
    for (int k = 0; k < 2; k++) {
        job.counts[k] = 1;
        job.half[k][0] = 10.0f;
        job.half[k][1] = 20.0f;
        for (size_t i = 0; i < 2; i++) {
            model.screen[k][2 * i] = 0.3f * (float)(k + 1);
            model.screen[k][2 * i + 1] = 0.2f * (float)(k + 1);
            model.seen[k][i] = i == (size_t)k;
        }
    }
    gsf__visit_chunk(&job, 0, 0);
    for (int k = 0; k < 2; k++)
        for (size_t i = 0; i < 2; i++) {
            CHECK_NEAR(model.grad_sum[k][i], i == (size_t)k ? 5.0 * (k + 1) : 0.0, 1e-5);
            CHECK(model.visits[k][i] == (i == (size_t)k));
        }
    gsf__model_destroy(ctx, &model);
}

// ---- origins -------------------------------------------------------------------

// A scene gets an origin of its own from 1e5 away, or from 1000 times its extent.
static void test_origin(void) {
    static const struct { double centre, extent; int moved; } cases[] = {
        {990.0, 1.0, 0}, {1010.0, 1.0, 1}, {-990.0, 1.0, 0}, {-1010.0, 1.0, 1}, {9900.0, 10.0, 0}, {10100.0, 10.0, 1},
        {99000.0, 1000.0, 0}, {101000.0, 1000.0, 1}, {5.0, 0.0, 0}, {99000.0, 0.0, 0}, {101000.0, 0.0, 1}};
    enum { N = 201 };
    for (size_t i = 0; i < GSF__COUNT(cases); i++)
        for (int far_axis = 0; far_axis < 3; far_axis++) {
            double axis[3 * N], origin[3];
            for (int k = 0; k < 3; k++)
                for (int j = 0; j < N; j++) // 5 % at either end are ignored as outliers
                    axis[k * N + j] = (k == far_axis ? cases[i].centre : 0.0) + cases[i].extent * (j - 100) / 180.0;
            axis[far_axis * N] -= 1e7;
            gsf__choose_origin(axis, N, origin);
            for (int k = 0; k < 3; k++)
                CHECK_NEAR(origin[k], cases[i].moved && k == far_axis ? floor(cases[i].centre + 0.5) : 0.0, 0.0);
        }
}

// ---- warp ----------------------------------------------------------------------

enum { SIDE = 16, PIXELS = SIDE * SIDE };

// A frame of SIDE pixels at the origin, `count` references that are moved by `shift` to the right, and the photos and
// depths of the first two, which are red and green.
typedef struct warp_case {
    float color[2][3 * PIXELS], depth[2][PIXELS], inv_z[2 * PIXELS];
    uint8_t score[2][PIXELS];
    gsf__carry_reference references[8];
    gsf__carrier carrier;
    gsf__warp_job job;
    gsf_camera camera;
} warp_case;

static void warp_case_init(warp_case* w, int count, double shift, const float depth[2], const int percent[2]) {
    memset(w, 0, sizeof *w);
    w->camera.w2c[0] = w->camera.w2c[5] = w->camera.w2c[10] = w->camera.w2c[15] = 1.0;
    w->camera.width = w->camera.height = SIDE;
    w->camera.fx = w->camera.fy = SIDE;
    w->camera.cx = w->camera.cy = SIDE / 2.0;
    for (int k = 0; k < 2; k++) {
        gsf__carry_reference* reference = w->references + k;
        reference->camera = w->camera;
        reference->camera.w2c[12] = -shift;
        reference->center[0] = shift;
        reference->color = w->color[k];
        reference->depth = w->depth[k];
        reference->score = w->score[k];
        for (int i = 0; i < PIXELS; i++) {
            for (int c = 0; c < 3; c++) w->color[k][3 * i + c] = c == k ? 1.0f : 0.0f;
            w->depth[k][i] = depth[k];
            w->score[k][i] = (uint8_t)percent[k];
            w->inv_z[k * PIXELS + i] = depth[k] > 0.0f ? 1.0f / depth[k] : 0.0f;
        }
    }
    w->carrier.references = w->references;
    w->carrier.count = count;
    w->job.near_count = 2;
    w->job.carrier = &w->carrier;
    w->job.nearest[1] = 1;
}

static float warp_middle(const warp_case* w, float shown, int opaque, float rgb[3]) {
    const int32_t x = SIDE / 2, y = SIDE / 2;
    return gsf__warp_pixel(&w->job, &w->camera, x, y, w->inv_z + y * SIDE + x, PIXELS, shown, opaque, rgb);
}

// Two references at the frame's own position show red at depth 1 and green at depth 2, with the given scores. The
// nearer surface is shown if it has at least 0.35 of the farther one's weight.
static int warp_shows_near(int near_percent, int far_percent) {
    static warp_case w;
    const float depth[2] = {1.0f, 2.0f};
    const int percent[2] = {near_percent, far_percent};
    warp_case_init(&w, 2, 0.0, depth, percent);
    float rgb[3] = {0.0f, 0.0f, 0.0f};
    const float confidence = warp_middle(&w, 5.0f, 1, rgb);
    CHECK(confidence > 0.0f && rgb[0] + rgb[1] > 0.99f && rgb[0] * rgb[1] < 1e-3f);
    return rgb[0] > 0.5f;
}

// Of `count` references, the nearest `seers` (1 or 2) are moved by `shift` and show red and green at depth 1 with this score,
// the frame grey at depth `shown`. Returns the confidence: 0 if and only if the grey stays.
static float warp_confidence(int count, int seers, double shift, float shown, int opaque, int percent) {
    static warp_case w;
    const float depth[2] = {1.0f, seers > 1 ? 1.0f : 0.0f};
    const int percents[2] = {percent, percent};
    warp_case_init(&w, count, shift, depth, percents);
    float rgb[3] = {0.2f, 0.2f, 0.2f};
    const float confidence = warp_middle(&w, shown, opaque, rgb);
    CHECK((confidence == 0.0f) == (rgb[0] == 0.2f && rgb[1] == 0.2f && rgb[2] == 0.2f));
    return confidence;
}

static int warp_keeps(int count, int seers, double shift, float shown, int opaque) {
    return warp_confidence(count, seers, shift, shown, opaque, 100) == 0.0f;
}

// What lies in front of the frame's surface counts a tenth, unless that is nearly transparent. What lies behind it is hidden,
// unless it is nearly transparent or references look through it, as those do that have it in their image: one of many, two of
// few photos, which are trusted by half then.
static void test_warp_hidden(void) {
    CHECK(warp_keeps(6, 2, 0.4, 0.5f, 1) && warp_keeps(8, 2, -0.4, 0.5f, 1));
    CHECK(warp_keeps(5, 2, 0.4, 0.5f, 1) && warp_keeps(2, 2, 0.4, 0.5f, 1) && !warp_keeps(6, 2, 0.4, 0.95f, 1));
    CHECK(!warp_keeps(6, 2, 0.0, 0.5f, 1) && !warp_keeps(6, 2, 0.1, 0.5f, 1)); // looked through
    CHECK(warp_keeps(5, 2, 0.4, 0.93f, 1) && !warp_keeps(6, 2, 0.4, 0.93f, 1)); // by a smaller difference, of few photos
    CHECK(!warp_keeps(5, 2, 0.1, 0.5f, 1) && warp_keeps(5, 1, 0.0, 0.5f, 1) && !warp_keeps(6, 1, 0.0, 0.5f, 1));
    for (int count = 5; count <= 6; count++) {
        CHECK(!warp_keeps(count, 2, 0.4, 0.5f, 0) && !warp_keeps(count, 2, 0.4, 0.0f, 1)); // transparent, or nothing there
        CHECK(!warp_keeps(count, 2, 0.4, 1.03f, 1) && !warp_keeps(count, 2, 0.4, 0.97f, 1)); // hardly in front or behind
        CHECK(!warp_keeps(count, 2, 0.4, 2.0f, 1) && !warp_keeps(count, 2, 0.4, 2.0f, 0)); // in front
        const float verified = warp_confidence(count, 2, 0.0, 1.0f, 1, 100);
        CHECK_NEAR(warp_confidence(count, 2, 0.0, 1.05f, 1, 100), 0.1f * verified, 1e-6);
        CHECK_NEAR(warp_confidence(count, 2, 0.0, 1.05f, 0, 100), verified, 1e-6);
        CHECK_NEAR(warp_confidence(count, 2, 0.0, 1.03f, 1, 100), verified, 1e-6);
        const float floater = warp_confidence(count, 2, 0.0, 0.5f, 1, 100);
        CHECK_NEAR(floater, (count < 6 ? 0.5f : 1.0f) * verified, 1e-6);
        CHECK(verified > 0.0f);
        // what nothing verifies is hidden, too, and replaces no floater of few photos
        const float usual = warp_confidence(count, 2, 0.0, 2.0f, 0, 30);
        const float looked_through = warp_confidence(count, 2, 0.0, 0.6f, 1, 30);
        if (count < 6) CHECK_NEAR(looked_through, 0.5f * usual, 1e-6);
        else CHECK(looked_through > usual);
        CHECK(warp_confidence(count, 2, 0.4, 0.5f, 1, 30) == 0.0f);
    }
}

static void test_warp_groups(void) {
    CHECK(warp_shows_near(100, 100) && warp_shows_near(36, 100) && warp_shows_near(19, 50));
    CHECK(!warp_shows_near(34, 100) && !warp_shows_near(16, 50) && !warp_shows_near(1, 100));
    CHECK(warp_shows_near(100, 10)); // in front and heavier: the other is hidden
}

// ---- dense points --------------------------------------------------------------

// A point 100 units away and two cameras whose rays to it are `degrees` apart.
static double dense_vote(const gsf_dense_desc* desc, double degrees) {
    gsf__dense_job job;
    gsf_camera a, b;
    memset(&job, 0, sizeof job);
    memset(&a, 0, sizeof a);
    job.desc = gsf__dense_desc_defaults(desc);
    a.w2c[0] = a.w2c[5] = a.w2c[10] = a.w2c[15] = 1.0;
    a.fx = a.fy = 100.0;
    b = a;
    const double angle = degrees * 3.14159265358979323846 / 180.0;
    b.w2c[12] = -100.0 * sin(angle);                   // minus its position
    b.w2c[14] = -(100.0 - 100.0 * cos(angle));
    const double point[3] = {0.0, 0.0, 100.0};
    return gsf__dense_vote(&job, &a, &b, point, 100.0, 100.0);
}

static void test_dense_angles(void) {
    gsf_dense_desc desc;
    memset(&desc, 0, sizeof desc);
    CHECK(dense_vote(NULL, 0.95) == 0.0 && dense_vote(NULL, 1.05) > 0.0);
    CHECK(dense_vote(NULL, 10.0) > 0.99 && dense_vote(NULL, 6.0) < 0.51 && dense_vote(NULL, 30.0) < 0.51);
    desc.min_angle = 5.0f;
    CHECK(dense_vote(&desc, 4.9) == 0.0 && dense_vote(&desc, 5.1) > 0.0);
    CHECK(gsf__dense_desc_defaults(NULL).max_normal_angle == 40.0f);
}

// The mean colour of a photo, of all its pixels or of those that a mask leaves.
static void test_mean(void) {
    uint8_t photo[6] = {51, 102, 0, 255, 204, 0}, mask[2] = {255, 0};
    double mean[3];
    gsf_scene_view view;
    memset(&view, 0, sizeof view);
    view.image = gsf_wrap_image(photo, GSF_U8, 2, 1, 3);
    gsf__carry_mean(&view, mean);
    CHECK(fabs(mean[0] - 0.6) < 1e-6 && fabs(mean[1] - 0.6) < 1e-6 && mean[2] == 0.0);
    view.weight = gsf_wrap_image(mask, GSF_U8, 2, 1, 1);
    gsf__carry_mean(&view, mean);
    CHECK(fabs(mean[0] - 0.2) < 1e-6 && fabs(mean[1] - 0.4) < 1e-6 && mean[2] == 0.0);
    mask[0] = 0;
    gsf__carry_mean(&view, mean);
    CHECK(mean[0] == 0.0 && mean[1] == 0.0 && mean[2] == 0.0);
}

// A camera that makes every photo as bright has the slope 1, one of a fixed exposure 0, and so has one whose photos are alike.
static void test_meter(void) {
    enum { PHOTOS = 3 };
    uint8_t photos[PHOTOS][3];
    gsf_scene_view views[PHOTOS];
    gsf__carry_study studies[PHOTOS];
    gsf__carrier carrier;
    memset(views, 0, sizeof views);
    memset(studies, 0, sizeof studies);
    memset(&carrier, 0, sizeof carrier);
    carrier.studies = studies;
    carrier.study_count = PHOTOS;
    for (int kind = 0; kind < 3; kind++) {
        for (int i = 0; i < PHOTOS; i++) {
            const int shown = kind == 2 ? 100 : 60 + 40 * i; // at one exposure
            memset(photos[i], kind ? shown : 100, 3);
            views[i].image = gsf_wrap_image(photos[i], GSF_U8, 1, 1, 3);
            for (int c = 0; c < 3; c++) studies[i].gain[c] = kind ? 1.0f : (float)shown / 100.0f;
        }
        gsf__carry_meter(&carrier, views);
        CHECK(kind ? carrier.automatic == 0.0 : carrier.automatic > 0.98 && carrier.automatic <= 1.0);
        for (int i = 0; i < PHOTOS; i++)
            CHECK(fabs(exp(studies[i].brightness) * 255.0 - (kind == 2 ? 100 : 60 + 40 * i)) < 1e-3);
    }
}

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    test_restored_weight();
    test_restored_step_weight();
    test_densify_means(&ctx);
    test_visits(&ctx);
    test_origin();
    test_warp_groups();
    test_warp_hidden();
    test_dense_angles();
    test_mean();
    test_meter();
    return test_report();
}
