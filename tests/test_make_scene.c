// test_make_scene.c - the true depth and normals of examples/make_scene.c against surfaces of known equations; that neither
// they nor the photos depend on the number of threads; that the scenes of the family are sound and differ.
// gcc -O2 -std=c11 -fopenmp -I. -Itests -DGSFIXER_IMPLEMENTATION tests/test_make_scene.c -lm; also with -DGSF_USE_EMBREE
#define _XOPEN_SOURCE 700 // mkdir
#define _POSIX_C_SOURCE 200809L
#include "gsfixer_splat.h"

#include "test.h"
#include "made_scene.h"

enum { WIDTH = 96, HEIGHT = 72, PIXELS = WIDTH * HEIGHT, VIEWS = 6 };

typedef struct truth {
    uint8_t pixels[3 * PIXELS];
    float depth[PIXELS], normal[3 * PIXELS];
} truth;

// The loop over threads in reverse order: results must not depend on the order of rows and chunks.
static void backwards(void* user, size_t count, gsf_chunk_fn fn, void* arg) {
    (void)user;
    while (count-- > 0) fn(arg, count, 0);
}

static void take(gsf_context* ctx, const world* s, const gsf_camera* camera, float exposure, truth* out) {
    photo_job job = {s, *camera, 0, out->pixels, out->depth, out->normal, exposure};
    ctx->parallel.for_fn(ctx->parallel.user, HEIGHT, photo_row, &job);
}

// Counts of the pixels on each surface whose equation is known.
typedef struct tally { size_t sky, wall, ball, faces; } tally;

static void check_pixel(const gsf_camera* camera, const truth* got, int x, int y, tally* seen) {
    const size_t pixel = (size_t)y * WIDTH + (size_t)x;
    const float *n = got->normal + 3 * pixel, depth = got->depth[pixel];
    float z;
    const v3 d = ray_through(camera, x + 0.5, y + 0.5, &z), eye = eye_of(camera), normal = v(n[0], n[1], n[2]);
    if (depth == 0.0f) {
        seen->sky++;
        CHECK(n[0] == 0.0f && n[1] == 0.0f && n[2] == 0.0f);
        return;
    }
    CHECK_NEAR(dot(normal, normal), 1.0f, 1e-5);
    CHECK(dot(normal, d) <= 0.0f);
    const v3 at = add(eye, mul(d, depth / z)), center = v(0.95f, -0.85f, 0.255f), out = sub(at, center);
    const float radius = sqrtf(dot(out, out));
    // The walls at +-5; the ones of bricks end below their copings at 2.4, the others at 2.0.
    if (fabsf(fabsf(at.x) - 5.0f) < 1e-3f && fabsf(at.y) < 4.9f && at.z > 0.2f && at.z < 1.9f) {
        seen->wall++;
        CHECK_NEAR(fabsf(normal.x), 1.0f, 1e-5);
    } else if (fabsf(fabsf(at.y) - 5.0f) < 1e-3f && fabsf(at.x) < 4.9f && at.z > 0.2f && at.z < 2.3f) {
        seen->wall++;
        CHECK_NEAR(fabsf(normal.y), 1.0f, 1e-5);
    } else if (radius < 0.2605f && at.z > 0.1f && dot(out, d) < -0.05f) { // a mesh of 48 x 32 quads, off by 0.3 % at most
        seen->ball++;
        CHECK(radius > 0.258f);
        CHECK(dot(normal, mul(out, 1.0f / radius)) > 0.995f); // 5.7 degrees, half the diagonal of a quad being 4.8
    }
}

// On smooth surfaces, the differences of neighbouring depths give the normals.
static void check_slope(const gsf_camera* camera, const truth* got, int x, int y, tally* seen, size_t* wrong) {
    v3 at[3];
    for (int i = 0; i < 3; i++) {
        const int px = x + (i == 1), py = y + (i == 2);
        const size_t pixel = (size_t)py * WIDTH + (size_t)px;
        float z;
        const v3 d = ray_through(camera, px + 0.5, py + 0.5, &z);
        if (got->depth[pixel] == 0.0f) return;
        if (fabsf(got->depth[pixel] / got->depth[(size_t)y * WIDTH + (size_t)x] - 1.0f) > 0.03f) return; // an edge
        at[i] = add(eye_of(camera), mul(d, got->depth[pixel] / z));
    }
    const float* n = got->normal + 3 * ((size_t)y * WIDTH + (size_t)x);
    seen->faces++;
    *wrong += fabsf(dot(unit(cross(sub(at[1], at[0]), sub(at[2], at[0]))), v(n[0], n[1], n[2]))) < 0.94f; // 20 degrees
}

// --drift changes the photos alone, within its range and in both directions.
static void test_exposure(gsf_context* ctx, const world* s, make_scene_options o) {
    static truth even, bright;
    const gsf_camera camera = camera_of((world*)s, &o, 0);
    float lowest = 1.0f, highest = 1.0f;
    for (uint64_t view = 0; view < 40; view++) CHECK(exposure_of(&o, view) == 1.0f);
    o.drift = 2.0;
    for (uint64_t view = 0; view < 40; view++) {
        lowest = minf(lowest, exposure_of(&o, view));
        highest = maxf(highest, exposure_of(&o, view));
    }
    CHECK(lowest >= 0.5f && lowest < 0.52f && highest <= 2.0f && highest > 1.94f);
    take(ctx, s, &camera, 1.0f, &even);
    take(ctx, s, &camera, 2.0f, &bright);
    double sums[2] = {0, 0};
    for (size_t i = 0; i < 3 * PIXELS; i++) {
        CHECK(bright.pixels[i] >= even.pixels[i]); // the same noise
        sums[0] += even.pixels[i], sums[1] += bright.pixels[i];
    }
    CHECK(sums[1] > 1.15 * sums[0]);
    CHECK(memcmp(even.depth, bright.depth, sizeof even.depth) == 0);
    CHECK(memcmp(even.normal, bright.normal, sizeof even.normal) == 0);
}

// The files hold what the camera saw.
static void test_files(gsf_context* ctx, make_scene_options* o) {
    static const char folder[] = TEST_TMP "/scene";
    static truth photo;
    static const struct { const char *name, *shape; size_t size; const float* values; } files[2] = {
        {"depth", "(72, 96), ", sizeof photo.depth, photo.depth},
        {"normal", "(72, 96, 3), ", sizeof photo.normal, photo.normal}};
    world s;
    o->points = 50;
    memset(&s, 0, sizeof s);
    CHECK(make_scene(ctx, o, folder) == 0);
    CHECK(start_world(ctx, &s, o));
    const gsf_camera camera = camera_of(&s, o, 0);
    take(ctx, &s, &camera, 1.0f, &photo);
    end_world(&s);
    for (int i = 0; i < 2; i++) {
        char path[1200], head[128];
        void* data = NULL;
        size_t size = 0;
        snprintf(path, sizeof path, "%s/truth/%s_001.npy", folder, files[i].name);
        CHECK_OK(ctx, gsf_read_file(ctx, path, &data, &size));
        CHECK(data && size == 128 + files[i].size);
        if (data && size == 128 + files[i].size) {
            CHECK(memcmp((const char*)data + 128, files[i].values, files[i].size) == 0);
            snprintf(head, sizeof head, "'shape': %s}", files[i].shape);
            char text[119] = "";
            memcpy(text, (const char*)data + 10, 118);
            CHECK(memcmp(data, "\x93NUMPY", 6) == 0 && strstr(text, head) != NULL);
        }
        gsf_free(ctx, data);
    }
    remove_scene(folder, o->views);
}

// At the poles of a sphere, too, the normals point outwards.
static void test_poles(void) {
    static const float sphere[4] = {0.5f, 1, 0, 0};
    const place at = {{0, 0, 0}, 0.3f};
    world s;
    float worst = 1.0f;
    memset(&s, 0, sizeof s);
    s.layout = 1;
    add_patch(&s, patch_sphere, sphere, 28, 18, ENAMEL, 0, at);
    CHECK(!s.failed && s.vertex_count == 29 * 19);
    for (size_t i = 0; i < s.vertex_count; i++) worst = minf(worst, dot(s.vertices[i].normal, unit(s.vertices[i].at)));
    CHECK(worst > 0.99f);
    end_world(&s);
}

// A letter has ink on its strokes and none beside them.
static void test_letters(void) {
    CHECK(ink_of("I", 0.5f, 1.5f, 0.1f, 0.01f) > 0.99f && ink_of("I", 0.1f, 1.0f, 0.1f, 0.01f) < 0.01f);
    CHECK(ink_of("HO", 2.0f, 2.0f, 0.1f, 0.01f) > 0.99f && ink_of("HO", 2.0f, 1.0f, 0.1f, 0.01f) < 0.01f);
    CHECK(ink_of("HO", 3.5f, 1.0f, 0.1f, 0.01f) < 0.01f && ink_of("H O", 2.0f, 1.0f, 0.1f, 0.01f) < 0.01f);
}

typedef struct sight { double mean[3 * 6 * 8]; } sight; // a photo of 96 x 72 in blocks of 12 x 12

static sight blurred(const truth* photo) {
    sight out;
    memset(&out, 0, sizeof out);
    for (size_t i = 0; i < PIXELS; i++)
        for (size_t k = 0; k < 3; k++)
            out.mean[3 * (i / WIDTH / 12 * 8 + i % WIDTH / 12) + k] += photo->pixels[3 * i + k] / 144.0;
    return out;
}

// A photo that is neither dark, nor blank, nor taken from inside of something, with the truth beside it.
static void check_photo(const gsf_camera* camera, const truth* photo) {
    double sum = 0.0, squares = 0.0;
    size_t hits = 0;
    for (size_t i = 0; i < PIXELS; i++) {
        const double x = photo->pixels[3 * i + 1];
        const float *n = photo->normal + 3 * i, depth = photo->depth[i];
        sum += x, squares += x * x;
        if (depth == 0.0f) continue;
        float z;
        const v3 d = ray_through(camera, (double)(i % WIDTH) + 0.5, (double)(i / WIDTH) + 0.5, &z);
        hits++;
        CHECK(depth > 0.12f);
        CHECK_NEAR(n[0] * n[0] + n[1] * n[1] + n[2] * n[2], 1.0f, 1e-4);
        CHECK(dot(v(n[0], n[1], n[2]), d) <= 1e-6f);
    }
    const double mean = sum / PIXELS, deviation = sqrt(squares / PIXELS - mean * mean);
    CHECK(hits > PIXELS / 2);
    if (!CHECK(mean > 45.0 && mean < 215.0 && deviation > 18.0)) printf("mean %.1f, deviation %.1f\n", mean, deviation);
}

// A scene of every layout: sound photos, no two alike, the same for any order of the work.
static void test_family(gsf_context* ctx, gsf_context* reversed) {
    static sight seen[LAYOUTS];
    static truth photo, other;
    size_t count = 0;
    double least = INFINITY;
    for (int i = 1; i < LAYOUTS; i++) {
        make_scene_options o = make_scene_defaults;
        world s, again;
        o.width = WIDTH, o.height = HEIGHT, o.views = VIEWS;
        o.layout = i, o.seed = 200 + (uint64_t)i;
        memset(&s, 0, sizeof s);
        memset(&again, 0, sizeof again);
        if (!CHECK(start_world(ctx, &s, &o))) return;
        for (int view = 1; view < VIEWS; view += 2) {
            const gsf_camera camera = camera_of(&s, &o, view);
            take(ctx, &s, &camera, 1.0f, &photo);
            check_photo(&camera, &photo);
        }
        const gsf_camera camera = camera_of(&s, &o, VIEWS / 2);
        take(ctx, &s, &camera, 1.0f, &photo);
        seen[count++] = blurred(&photo);
        if (i % 5 == 0) {
            CHECK(start_world(reversed, &again, &o));
            const gsf_camera same = camera_of(&again, &o, VIEWS / 2);
            CHECK(memcmp(&same, &camera, sizeof same) == 0);
            take(reversed, &again, &same, 1.0f, &other);
            CHECK(memcmp(&photo, &other, sizeof photo) == 0);
            end_world(&again);
        }
        end_world(&s);
    }
    for (size_t a = 0; a < count; a++)
        for (size_t b = 0; b < a; b++) {
            double sum = 0.0;
            for (size_t k = 0; k < 3 * 6 * 8; k++) sum += fabs(seen[a].mean[k] - seen[b].mean[k]);
            least = fmin(least, sum / (3 * 6 * 8));
        }
    printf("%zu scenes, the most alike differ by %.1f of 255\n", count, least);
    CHECK(least > 6.0);
}

int main(void) {
    static truth one, other;
    gsf_context ctx, reversed;
    memset(&ctx, 0, sizeof ctx);
    memset(&reversed, 0, sizeof reversed);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    reversed.parallel.for_fn = backwards;
    reversed.parallel.worker_count = 1;
    CHECK_OK(&reversed, gsf_init_context(&reversed));
    make_scene_options o = make_scene_defaults;
    o.width = WIDTH, o.height = HEIGHT, o.views = VIEWS, o.arc = 360.0;
    world s, again;
    memset(&s, 0, sizeof s);
    memset(&again, 0, sizeof again);
    const int started = start_world(&ctx, &s, &o) && start_world(&reversed, &again, &o);
    CHECK(started);
    tally seen = {0, 0, 0, 0};
    size_t wrong = 0;
    for (int view = 0; started && view < VIEWS; view++) {
        const gsf_camera camera = camera_of(&s, &o, view);
        take(&ctx, &s, &camera, 1.0f, &one);
        take(&reversed, &again, &camera, 1.0f, &other);
        CHECK(memcmp(&one, &other, sizeof one) == 0);
        for (int y = 0; y < HEIGHT; y++)
            for (int x = 0; x < WIDTH; x++) {
                check_pixel(&camera, &one, x, y, &seen);
                if (x + 1 < WIDTH && y + 1 < HEIGHT) check_slope(&camera, &one, x, y, &seen, &wrong);
            }
    }
    printf("sky %zu, walls %zu, ball %zu; slopes of %zu pixels, %zu others\n", seen.sky, seen.wall, seen.ball, seen.faces,
           wrong);
    CHECK(seen.sky > 5 && seen.wall > 1000 && seen.ball > 100);
    CHECK(seen.faces > 20000 && wrong < seen.faces / 10); // bushes and edges
    if (started) test_exposure(&ctx, &s, o);
    end_world(&s);
    end_world(&again);
    test_files(&ctx, &o);
    test_poles();
    test_letters();
    test_family(&ctx, &reversed);
    return test_report();
}
