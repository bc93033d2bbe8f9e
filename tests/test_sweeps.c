// test_sweeps.c - the complete loop, from photos on disk to results on disk, under every failure of a hook: the k-th
// allocation, the k-th read, the k-th write. In each case the result reports the failure, nothing leaks, and existing
// files stay as they were; if the failed call is repeated, the run ends with the same bytes as one without failures.
#include "gsfixer_splat.h"
#include "test.h"
#include "test_hooks.h"

#if defined(__unix__) || defined(__APPLE__)
#include <dirent.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

enum { VIEWS = 4, WIDTH = 20, HEIGHT = 15, FOCAL = 18, POINTS = 60, ITERATIONS = 8 };

static char scene_folder[600], out_folder[600];
static const char* const outputs[] = { // in the order in which they are written
    "checkpoint", "splats.ply", "splats.splat", "splats.spz", "render.png", "render.jpg", "cameras.json",
    "sparse/0/points3D.bin", "sparse/0/images.bin", "sparse/0/cameras.bin"};
enum { OUTPUTS = sizeof outputs / sizeof *outputs };

static const char* in(const char* folder, const char* name) { // static buffers, the last 8 stay valid
    static char paths[8][800];
    static int turn;
    char* path = paths[turn++ & 7];
    snprintf(path, sizeof paths[0], "%s/%s", folder, name);
    return path;
}

// ---- the hooks -----------------------------------------------------------------

typedef enum fault { // how the k-th read or write fails
    NO_FAULT, READ_FAILS, READ_ABSENT, READ_CUT, READ_NO_HANDLE, WRITE_FAILS, WRITE_FULL_DISK, WRITE_ONTO_FOLDER
} fault;

typedef struct disk {
    gsf_io plain;
    fault kind;
    size_t reads, writes, fail_at; // counts reads or writes, depending on the kind; 1 = the first
    char failed[800];              // path of the call that was made to fail
} disk;

static int limit(int resource, rlim_t value, struct rlimit* was) {
    CHECK(getrlimit(resource, was) == 0);
    struct rlimit now = *was;
    now.rlim_cur = value;
    return CHECK(setrlimit(resource, &now) == 0);
}

static gsf_result disk_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    disk* d = (disk*)user;
    struct rlimit was;
    const int now = ++d->reads == d->fail_at && d->kind >= READ_FAILS && d->kind <= READ_NO_HANDLE;
    if (now) snprintf(d->failed, sizeof d->failed, "%s", path);
    if (now && d->kind == READ_FAILS) return gsf_fail(ctx, GSF_ERROR_IO, "%s: the host cannot read it", path);
    if (now && d->kind == READ_ABSENT) return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: the host has no such file", path);
    if (now && d->kind == READ_NO_HANDLE) limit(RLIMIT_NOFILE, 0, &was);
    const gsf_result result = d->plain.read_fn(d->plain.user, ctx, path, data, size);
    if (now && d->kind == READ_NO_HANDLE) CHECK(setrlimit(RLIMIT_NOFILE, &was) == 0);
    if (now && d->kind == READ_CUT && result == GSF_OK) *size /= 2;
    return result;
}

static gsf_result disk_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    disk* d = (disk*)user;
    struct rlimit was;
    const int now = ++d->writes == d->fail_at && d->kind >= WRITE_FAILS;
    if (now) snprintf(d->failed, sizeof d->failed, "%s", path);
    if (now && d->kind == WRITE_FAILS) return gsf_fail(ctx, GSF_ERROR_IO, "%s: the host cannot write it", path);
    if (now && d->kind == WRITE_FULL_DISK) limit(RLIMIT_FSIZE, size / 2, &was);
    if (now && d->kind == WRITE_ONTO_FOLDER) CHECK(remove(path) == 0 && mkdir(path, 0700) == 0);
    const gsf_result result = d->plain.write_fn(d->plain.user, ctx, path, data, size);
    if (now && d->kind == WRITE_FULL_DISK) CHECK(setrlimit(RLIMIT_FSIZE, &was) == 0);
    if (now && d->kind == WRITE_ONTO_FOLDER) CHECK(rmdir(path) == 0); // fails unless it is still an empty folder
    return result;
}

// ---- the loop ------------------------------------------------------------------

typedef struct loop {
    gsf_context ctx;
    counter memory;
    disk disk;
    int repeat;                 // repeat the first call that fails
    size_t failures;
    gsf_result first;           // result of the first call that failed
    char message[512], call[100]; // ctx->error after that call, and the call's name
    gsf_scene scene;
    gsf_dense dense;
    gsf_splats start, result, again;
    gsf_restorer warp;
    gsf_fixer *fixer, *resumed;
    gsf_train_view views[VIEWS];
    gsf_image picture;
    gsf_camera* cameras;
    size_t missing;
} loop;

static int shall_repeat(loop* l, gsf_result result, const char* call) {
    if (result == GSF_OK) return 0;
    if (l->failures++ == 0) {
        l->first = result;
        snprintf(l->message, sizeof l->message, "%s", l->ctx.error);
        snprintf(l->call, sizeof l->call, "%s", call);
    }
    return l->repeat && l->failures == 1;
}

#define STEP(call)                                  \
    do {                                            \
        gsf_result step_;                           \
        do step_ = (call);                          \
        while (shall_repeat(l, step_, #call));      \
        if (step_ != GSF_OK) return step_;          \
    } while (0)

static gsf_result write_checkpoint(loop* l) {
    gsf_buffer chunks = {0};
    gsf_splat_format_fixer(&l->ctx, l->fixer, &chunks);
    gsf_append_last_chunk(&l->ctx, &chunks);
    const gsf_result result = chunks.failed ? GSF_ERROR_OUT_OF_MEMORY
                                            : gsf_write_file(&l->ctx, in(out_folder, "checkpoint"), chunks.data, chunks.size);
    gsf_destroy_buffer(&l->ctx, &chunks);
    return result;
}

static gsf_result read_checkpoint(loop* l) {
    void* data;
    size_t size;
    gsf_result result = gsf_read_file(&l->ctx, in(out_folder, "checkpoint"), &data, &size);
    if (result == GSF_OK) result = gsf_splat_parse_fixer(&l->ctx, l->resumed, in(out_folder, "checkpoint"), data, size);
    gsf_free(&l->ctx, data);
    return result;
}

static gsf_result load(loop* l) {
    gsf_context* ctx = &l->ctx;
    uint8_t keep[POINTS];
    uint32_t all[VIEWS];
    gsf_visibility_desc discs = {0};
    gsf_dense_desc stereo = {0};
    discs.use_zbuffer = 1; // Embree allocates without the hook
    stereo.levels = stereo.iterations = 1;
    stereo.radius = 2;
    stereo.sources = 1;
    STEP(gsf_splat_load_scene(ctx, scene_folder, NULL, &l->scene));
    l->missing = l->scene.missing_count;
    for (uint32_t v = 0; v < l->scene.view_count; v++) {
        STEP(gsf_splat_load_view_image(ctx, &l->scene, v));
        l->views[v].camera = l->scene.views[v].camera;
        l->views[v].image = l->scene.views[v].image;
        all[v] = v;
    }
    STEP(gsf_splat_filter_points(ctx, &l->scene, all, l->scene.view_count, &discs, keep, NULL));
    STEP(gsf_splat_make_dense(ctx, &l->scene, all, l->scene.view_count < 2 ? 1 : 2, keep, &stereo, &l->dense, NULL));
    STEP(gsf_splat_make_from_points(ctx, l->scene.points, l->scene.colors, l->scene.point_count, keep, 1,
                                    l->scene.origin, &l->start));
    STEP(gsf_splat_sort(ctx, &l->start));
    return GSF_OK;
}

static gsf_result repair(loop* l) {
    gsf_context* ctx = &l->ctx;
    gsf_fix_desc desc = {0};
    gsf_fix_stats stats;
    desc.train.iterations = ITERATIONS;
    desc.train.densify_from = 1;
    desc.train.densify_interval = 2;
    desc.train.densify_grad = 1e-9f;
    desc.train.sh_interval = 2;
    desc.train.max_splats = 200;
    desc.train.dropout = 0.1f;
    desc.train.depth_smoothness = 0.1f;
    desc.points = l->scene.points;
    desc.point_count = l->scene.point_count;
    desc.rounds = 2;
    desc.first_round = 3;
    desc.last_round = 6;
    desc.windows = 2;
    desc.window_frames = 3;
    desc.skip_psnr = 60.0f;
    STEP(gsf_splat_make_warp(ctx, &l->warp));
    STEP(gsf_splat_make_fixer(ctx, &desc, l->views, l->scene.view_count, &l->start, &l->warp, &l->fixer));
    do STEP(gsf_splat_step_fixer(ctx, l->fixer, &stats));
    // the first round's frames are being trained on, the second round's are next
    while (stats.stage != GSF_FIX_RESTORE || stats.round != 2);
    STEP(write_checkpoint(l));
    gsf_splat_destroy_fixer(ctx, l->fixer);
    l->fixer = NULL;
    STEP(gsf_splat_make_fixer(ctx, &desc, l->views, l->scene.view_count, &l->start, &l->warp, &l->resumed));
    STEP(read_checkpoint(l));
    do STEP(gsf_splat_step_fixer(ctx, l->resumed, &stats));
    while (stats.stage != GSF_FIX_DONE);
    STEP(gsf_splat_copy_trained(ctx, gsf_splat_get_trainer(l->resumed), &l->result));
    return GSF_OK;
}

static gsf_result save(loop* l) {
    gsf_context* ctx = &l->ctx;
    gsf_render_output rendered = {0};
    gsf_camera cameras[VIEWS];
    size_t count;
    for (size_t v = 0; v < l->scene.view_count; v++) cameras[v] = l->views[v].camera;
    STEP(gsf_splat_save(ctx, in(out_folder, "splats.ply"), &l->result, NULL));
    STEP(gsf_splat_save(ctx, in(out_folder, "splats.splat"), &l->result, NULL));
    STEP(gsf_splat_save(ctx, in(out_folder, "splats.spz"), &l->result, NULL));
    for (int i = 0; i < 3; i++) {
        STEP(gsf_splat_load(ctx, in(out_folder, outputs[1 + i]), &l->again));
        gsf_splat_destroy(ctx, &l->again);
    }
    STEP(gsf_make_image(ctx, GSF_F32, cameras[0].width, cameras[0].height, 3, &l->picture));
    rendered.color = l->picture;
    STEP(gsf_splat_render_trainer(ctx, gsf_splat_get_trainer(l->resumed), &cameras[0], &rendered));
    STEP(gsf_save_image(ctx, in(out_folder, "render.png"), &l->picture));
    STEP(gsf_save_image(ctx, in(out_folder, "render.jpg"), &l->picture));
    STEP(gsf_save_cameras(ctx, in(out_folder, "cameras.json"), cameras, NULL, l->scene.view_count));
    STEP(gsf_load_cameras(ctx, in(out_folder, "cameras.json"), &l->cameras, &count));
    STEP(gsf_splat_save_colmap(ctx, &l->scene, NULL, out_folder));
    return GSF_OK;
}

static gsf_result run(loop* l) {
    gsf_result result = load(l);
    if (result == GSF_OK) result = repair(l);
    if (result == GSF_OK) result = save(l);
    gsf_free(&l->ctx, l->cameras);
    gsf_destroy_image(&l->ctx, &l->picture);
    gsf_splat_destroy(&l->ctx, &l->again);
    gsf_splat_destroy(&l->ctx, &l->result);
    gsf_splat_destroy(&l->ctx, &l->start);
    if (l->fixer) gsf_splat_destroy_fixer(&l->ctx, l->fixer);
    if (l->resumed) gsf_splat_destroy_fixer(&l->ctx, l->resumed);
    gsf_destroy_restorer(&l->ctx, &l->warp);
    gsf_splat_destroy_dense(&l->ctx, &l->dense);
    gsf_splat_destroy_scene(&l->ctx, &l->scene);
    return result;
}

static void begin(loop* l, int repeat) {
    memset(l, 0, sizeof *l);
    test_context_init(&l->ctx);
    l->disk.plain = l->ctx.io;
    test_context_zero(&l->ctx);
    count_memory(&l->ctx, &l->memory);
    l->ctx.threads = 1;
    l->ctx.io.read_fn = disk_read;
    l->ctx.io.write_fn = disk_write;
    l->ctx.io.user = &l->disk;
    CHECK_OK(&l->ctx, gsf_init_context(&l->ctx));
    l->repeat = repeat;
}

// ---- files on disk -------------------------------------------------------------

static struct { char* data; size_t size; } wanted[OUTPUTS]; // contents after a run without failures

static void put_old(int i) { // outputs have other contents before each run
    FILE* file = fopen(in(out_folder, outputs[i]), "wb");
    if (!CHECK(file != NULL)) return;
    fprintf(file, "old %s", outputs[i]);
    fclose(file);
}

static int files_below(const char* folder) {
    int count = 0;
    DIR* list = opendir(folder);
    if (!CHECK(list != NULL)) return -1;
    for (const struct dirent* entry; (entry = readdir(list)) != NULL;) {
        struct stat info;
        const char* path = in(folder, entry->d_name);
        if (entry->d_name[0] == '.' || stat(path, &info) != 0) continue;
        char below[800];
        snprintf(below, sizeof below, "%s", path);
        count += S_ISDIR(info.st_mode) ? files_below(below) : 1;
    }
    closedir(list);
    return count;
}

// Each output is either the old or the new one, new ones come before old ones in the order of writing, and there are no
// other files. Then restores the old outputs.
static int outputs_are_whole(const char* failed, int all_new) {
    int whole = 1, old_seen = 0;
    for (int i = 0; i < OUTPUTS; i++) {
        const char* path = in(out_folder, outputs[i]);
        char old[100];
        snprintf(old, sizeof old, "old %s", outputs[i]);
        if (access(path, F_OK) != 0 && strcmp(path, failed) == 0) { // there was a folder in its place
            old_seen = 1;
            put_old(i);
            continue;
        }
        size_t size;
        char* data = test_read_file(path, &size);
        const int is_old = size == strlen(old) && memcmp(data, old, size) == 0;
        const int is_new = size == wanted[i].size && memcmp(data, wanted[i].data, size) == 0;
        whole &= (is_old && !all_new) || (is_new && !old_seen && strcmp(path, failed) != 0) || (is_new && all_new);
        old_seen |= is_old;
        free(data);
        if (!is_old) put_old(i);
    }
    return whole && files_below(out_folder) == OUTPUTS;
}

// ---- the scene -----------------------------------------------------------------

// Cameras in a shallow bow before a textured wall at z = 4, with a lens that has to be undistorted; photos of both kinds.
static void photo_of(gsf_context* ctx, double x, double y, double turn, const char* path) {
    gsf_image image;
    if (!CHECK_OK(ctx, gsf_make_image(ctx, GSF_U8, WIDTH, HEIGHT, 3, &image))) return;
    for (int row = 0; row < HEIGHT; row++)
        for (int column = 0; column < WIDTH; column++) {
            const double u = (column + 0.5 - WIDTH / 2.0) / FOCAL, v = (row + 0.5 - HEIGHT / 2.0) / FOCAL;
            const double depth = 4 / (cos(turn) - sin(turn) * u), at_x = x + depth * (cos(turn) * u + sin(turn));
            for (int c = 0; c < 3; c++)
                ((uint8_t*)image.data)[3 * (row * WIDTH + column) + c] =
                    (uint8_t)(128 + 100 * sin(7 * at_x + c) * cos(5 * (y + depth * v) + 2 * c));
        }
    CHECK_OK(ctx, gsf_save_image(ctx, path, &image));
    gsf_destroy_image(ctx, &image);
}

static void make_inputs(void) {
    char command[4000];
    gsf_context ctx;
    uint64_t seed = 3;
    test_context_init(&ctx);
    snprintf(scene_folder, sizeof scene_folder, "%s", test_scratch("sweep_scene"));
    snprintf(out_folder, sizeof out_folder, "%s", test_scratch("sweep_out"));
    snprintf(command, sizeof command, "rm -rf '%s' '%s' && mkdir -p '%s/images' '%s/sparse/0' '%s/sparse/0'", scene_folder,
             out_folder, scene_folder, scene_folder, out_folder);
    CHECK(system(command) == 0);
    FILE* cameras = fopen(in(scene_folder, "sparse/0/cameras.txt"), "w");
    FILE* images = fopen(in(scene_folder, "sparse/0/images.txt"), "w");
    FILE* points = fopen(in(scene_folder, "sparse/0/points3D.txt"), "w");
    if (!CHECK(cameras && images && points)) exit(1);
    fprintf(cameras, "1 SIMPLE_RADIAL %d %d %d %g %g 0.02\n", WIDTH, HEIGHT, FOCAL, WIDTH / 2.0, HEIGHT / 2.0);
    for (int i = 0; i < VIEWS; i++) {
        const double x = 0.3 * i - 0.45, y = i % 2 ? 0.1 : -0.1, turn = -0.2 * x;
        char name[20];
        snprintf(name, sizeof name, "images/%d.%s", i, i % 2 ? "jpg" : "png");
        photo_of(&ctx, x, y, turn, in(scene_folder, name));
        fprintf(images, "%d %.17g 0 %.17g 0 %.17g %.17g %.17g 1 %s\n\n", i + 1, cos(turn / 2), -sin(turn / 2), -x * cos(turn),
                -y, -x * sin(turn), name + 7);
    }
    for (int i = 0; i < POINTS; i++)
        fprintf(points, "%d %.17g %.17g 4 200 100 50 0.5 1 %d 2 %d 3 %d\n", i + 1, test_random_in(&seed, -2, 2),
                test_random_in(&seed, -1.5, 1.5), i, i, i);
    fclose(cameras);
    fclose(images);
    fclose(points);
}

// ---- the sweeps ----------------------------------------------------------------

static void tell(const loop* l, const char* sweep, size_t k, int ok) {
    if (!ok) fprintf(stderr, "  %s %zu%s: %s: %s (%s)\n", sweep, k, l->repeat ? ", repeated" : "", l->call,
                     gsf_describe_result(l->first), l->message);
}

// Every one of the first 200 calls, then some with random strides, so that no periodic pattern of the loop is skipped.
static size_t next(size_t k, size_t stride) {
    uint64_t state = k;
    return k < 200 || stride < 2 ? k + 1 : k + 1 + test_random_bits(&state) % (2 * stride - 1);
}

static void sweep_allocations(size_t total, size_t stride, int repeat) {
    static loop l;
    size_t runs = 0;
    for (size_t k = 1; k <= total; k = next(k, stride), runs++) {
        begin(&l, repeat);
        l.memory.fail_at = l.memory.calls + k;
        l.memory.stays = !repeat;
        const gsf_result result = run(&l);
        int ok = CHECK(l.first == GSF_ERROR_OUT_OF_MEMORY && strstr(l.message, "memory") != NULL);
        ok &= CHECK(result == (repeat ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY) && l.failures == 1);
        ok &= CHECK(l.memory.live == 0) & CHECK(outputs_are_whole("", repeat));
        tell(&l, "allocation", k, ok);
    }
    printf("allocations, %s: %zu of %zu\n", repeat ? "the call repeated" : "the end", runs, total);
}

static void sweep_files(fault kind, size_t total, int plain_files, int repeat) {
    static const char* const names[] = {"", "read", "absent", "cut", "read without a handle", "write", "write to a full disk",
                                        "write onto a folder"};
    static loop l;
    for (size_t k = 1; k <= total; k++) {
        begin(&l, repeat);
        l.ctx.io.plain_files = plain_files;
        l.disk.kind = kind;
        l.disk.fail_at = k;
        const gsf_result result = run(&l);
        // reads that may be missing: one photo less, a shorter list of points
        const int may_pass = kind == READ_ABSENT || kind == READ_CUT;
        int ok = CHECK(l.memory.live == 0 && l.disk.failed[0]);
        if (may_pass) {
            for (int i = 0; i < OUTPUTS; i++) put_old(i);
            ok &= CHECK(kind == READ_CUT || result == GSF_OK || result == GSF_ERROR_NOT_FOUND);
            ok &= CHECK(result == GSF_OK || l.message[0]);
        } else {
            ok &= CHECK(l.first == GSF_ERROR_IO && strstr(l.message, l.disk.failed) != NULL && l.failures == 1);
            ok &= CHECK(result == (repeat ? GSF_OK : GSF_ERROR_IO));
            ok &= CHECK(outputs_are_whole(kind >= WRITE_FAILS && !repeat ? l.disk.failed : "", repeat));
        }
        tell(&l, names[kind], k, ok);
    }
}

int main(void) {
    static loop l;
    signal(SIGXFSZ, SIG_IGN);
    make_inputs();
    begin(&l, 0);
    for (int i = 0; i < OUTPUTS; i++) put_old(i);
    const size_t before = l.memory.calls;
    if (!CHECK_OK(&l.ctx, run(&l)) || !CHECK(l.memory.live == 0)) return test_report();
    const size_t allocations = l.memory.calls - before, reads = l.disk.reads, writes = l.disk.writes;
    for (int i = 0; i < OUTPUTS; i++) wanted[i].data = test_read_file(in(out_folder, outputs[i]), &wanted[i].size);
    CHECK(writes == OUTPUTS && l.missing == 0 && outputs_are_whole("", 1));
    printf("%zu allocations, %zu reads, %zu writes\n", allocations, reads, writes);
    for (int repeat = 0; repeat < 2; repeat++) {
        sweep_allocations(allocations, (size_t)test_few(1, 2), repeat);
        sweep_files(READ_FAILS, reads, 0, repeat);
        sweep_files(READ_NO_HANDLE, reads, 0, repeat);
        sweep_files(WRITE_FAILS, writes, 0, repeat);
        sweep_files(WRITE_FULL_DISK, writes, 0, repeat);
    }
    sweep_files(READ_ABSENT, reads, 0, 0);
    sweep_files(READ_CUT, reads, 0, 0);
    sweep_files(WRITE_ONTO_FOLDER, writes, 0, 0);
    for (int i = 0; i < OUTPUTS; i++) free(wanted[i].data);
    return test_report();
}
#else
int main(void) { return TEST_SKIPPED; }
#endif
