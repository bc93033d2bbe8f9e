// test_make_scene.c - the true depth and normals of examples/make_scene.c against surfaces of known equations, and that
// neither they nor the photos depend on the number of threads.
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
    return test_report();
}
