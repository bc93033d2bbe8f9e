// splat_run.h - shared by the tests of the rasterizer: machines (a context with a given CPU level and order of work,
// and a rasterizer), one render with all gradients, random cameras. Include gsfixer_splat.h, test.h and
// reference_splat.h first.
#ifndef SPLAT_RUN_H
#define SPLAT_RUN_H

// ---- contexts ------------------------------------------------------------------

enum { WORKERS = 3 };
static const int one_worker = 1, many_workers = WORKERS;

static inline size_t workers_of(const void* user) { return (size_t)(*(const int*)user); }

// Job systems; user: the number of workers. The first one runs chunks in order; the second one deviates as far as the
// hook's contract allows: last chunk first. Both change the worker from chunk to chunk.
static inline void for_in_order(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    for (size_t i = 0; i < chunk_count; i++) body(arg, i, (int)((i * 2654435761u >> 7) % workers_of(user)));
}
static inline void for_reversed(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    for (size_t i = chunk_count; i-- > 0;) body(arg, i, (int)((i * 2654435761u >> 7) % workers_of(user)));
}

static size_t allocations; // calls of the counting allocator
static inline void* counting_alloc(void* user, size_t size) { (void)user; allocations++; return malloc(size); }
static inline void counting_free(void* user, void* memory) { (void)user; free(memory); }

typedef struct machine { gsf_context ctx; gsf_rasterizer* rasterizer; const char* name; } machine;

// Returns 0 if the CPU lacks the level.
static inline int machine_open(machine* m, gsf_cpu_level level, int reversed) {
    memset(m, 0, sizeof *m);
    m->ctx.cpu_level = level;
    m->ctx.parallel.for_fn = reversed ? for_reversed : for_in_order;
    m->ctx.parallel.worker_count = reversed ? many_workers : one_worker;
    m->ctx.parallel.user = (void*)(uintptr_t)(reversed ? &many_workers : &one_worker);
    m->ctx.allocator.alloc_fn = counting_alloc;
    m->ctx.allocator.free_fn = counting_free;
    CHECK_OK(&m->ctx, gsf_init_context(&m->ctx));
    if (m->ctx.cpu_level != level) return 0;
    m->name = gsf_describe_cpu_level(level);
    return CHECK_OK(&m->ctx, gsf_splat_make_rasterizer(&m->ctx, &m->rasterizer));
}

static inline void machine_close(machine* m) { gsf_splat_destroy_rasterizer(&m->ctx, m->rasterizer); }

// One machine for each level that this computer supports, scalar first; returns their number.
enum { MACHINES = 4 };
static inline size_t machines_open(machine levels[MACHINES]) {
    static const gsf_cpu_level known[MACHINES] = {GSF_CPU_SCALAR, GSF_CPU_AVX2, GSF_CPU_AVX512, GSF_CPU_SIMD128};
    size_t count = 0;
    for (size_t k = 0; k < MACHINES; k++) count += (size_t)(machine_open(&levels[count], known[k], 0) != 0);
    CHECK(count > 0);
    return count;
}

// ---- one render and its gradients ----------------------------------------------

typedef struct result { // arrays lie in one block: color depth alpha | means log_scales quats logits sh means2d abs bg
    size_t floats, splat_count, pixels, sh_floats;
    float* block;
    float *color, *depth, *alpha;
    gsf_splat_grads grads;
    int32_t* radii;
} result;

typedef struct loss { double *d_color, *d_depth, *d_alpha; } loss; // (H,W,3), (H,W), (H,W)

static inline result result_make(const gsf_splats* splats, const gsf_camera* camera) {
    result r;
    memset(&r, 0, sizeof r);
    r.splat_count = splats->count;
    r.pixels = (size_t)camera->width * (size_t)camera->height;
    r.sh_floats = 3 * (size_t)gsf_splat_count_sh(splats->sh_degree);
    r.floats = 5 * r.pixels + splats->count * (3 + 3 + 4 + 1 + r.sh_floats + 2 + 2) + 3;
    r.block = (float*)calloc(r.floats, sizeof(float));
    r.color = r.block;
    r.depth = r.color + 3 * r.pixels;
    r.alpha = r.depth + r.pixels;
    r.grads.means = r.alpha + r.pixels;
    r.grads.log_scales = r.grads.means + 3 * splats->count;
    r.grads.quats = r.grads.log_scales + 3 * splats->count;
    r.grads.opacity_logits = r.grads.quats + 4 * splats->count;
    r.grads.sh = r.grads.opacity_logits + splats->count;
    r.grads.means2d = r.grads.sh + r.sh_floats * splats->count;
    r.grads.means2d_abs = r.grads.means2d + 2 * splats->count;
    r.grads.background = r.grads.means2d_abs + 2 * splats->count;
    r.radii = (int32_t*)calloc(splats->count + 1, sizeof(int32_t));
    return r;
}
static inline void result_free(result* r) { free(r->block); free(r->radii); }

static inline float* narrow(const double* values, size_t count) {
    float* out = (float*)malloc((count + 1) * sizeof(float));
    for (size_t i = 0; i < count; i++) out[i] = (float)values[i];
    return out;
}

static inline gsf_image packed_view(float* data, const gsf_camera* camera, int32_t channels) {
    gsf_image view;
    memset(&view, 0, sizeof view);
    view.data = data;
    view.dtype = GSF_F32;
    view.width = camera->width;
    view.height = camera->height;
    view.channels = channels;
    view.stride_c = (int64_t)sizeof(float);
    view.stride_x = channels * view.stride_c;
    view.stride_y = view.width * view.stride_x;
    return view;
}

static inline gsf_render_output result_output(const result* r, const gsf_camera* camera) {
    gsf_render_output out;
    out.color = packed_view(r->color, camera, 3);
    out.depth = packed_view(r->depth, camera, 1);
    out.alpha = packed_view(r->alpha, camera, 1);
    return out;
}

static inline result render(machine* m, const gsf_splats* splats, const gsf_camera* camera, const gsf_render_desc* desc,
                     const loss* l) {
    result r = result_make(splats, camera);
    const gsf_render_output out = result_output(&r, camera);
    CHECK_OK(&m->ctx, gsf_splat_render(&m->ctx, m->rasterizer, splats, camera, desc, &out));
    const int32_t* radii = m->rasterizer->radii;
    if (splats->count && CHECK(radii != NULL)) memcpy(r.radii, radii, splats->count * sizeof(int32_t));
    float* d_color = narrow(l->d_color, 3 * r.pixels);
    float* d_depth = l->d_depth ? narrow(l->d_depth, r.pixels) : NULL;
    float* d_alpha = l->d_alpha ? narrow(l->d_alpha, r.pixels) : NULL;
    CHECK_OK(&m->ctx, gsf_splat_render_backward(&m->ctx, m->rasterizer, splats, camera, desc, d_color, d_depth, d_alpha,
                                                &r.grads));
    free(d_color); free(d_depth); free(d_alpha);
    return r;
}

static inline int same_bits(const result* a, const result* b) {
    return memcmp(a->block, b->block, a->floats * sizeof(float)) == 0 &&
           memcmp(a->radii, b->radii, a->splat_count * sizeof(int32_t)) == 0;
}

// ---- numbers -------------------------------------------------------------------

static inline double nan_max(double a, double b) { return b != b || b > a ? b : a; } // a NaN error stays

static inline double* random_values(uint64_t* state, size_t count, double size) {
    double* v = (double*)malloc((count + 1) * sizeof(double));
    for (size_t i = 0; i < count; i++) v[i] = (double)(float)test_random_in(state, -size, size);
    return v;
}

static inline double random_log(uint64_t* state, double lo, double hi) {
    return exp(test_random_in(state, log(lo), log(hi)));
}

static inline gsf_camera random_camera(uint64_t* state, int32_t width, int32_t height, const double look_at[3],
                                double distance) {
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    double q[4], unit[4], R[3][3];
    for (int k = 0; k < 4; k++) q[k] = test_random_in(state, -1, 1);
    ref_rotation(q, unit, R);
    for (int r = 0; r < 3; r++) {
        for (int c = 0; c < 3; c++) camera.w2c[4 * c + r] = R[r][c];
        camera.w2c[12 + r] = (r == 2 ? distance : 0) - ref_dot(R[r], look_at);
    }
    camera.w2c[15] = 1;
    camera.width = width;
    camera.height = height;
    const double focal = test_random_in(state, 0.6, 1.4) * (width > height ? width : height);
    camera.fx = focal;
    camera.fy = focal * test_random_in(state, 0.9, 1.1);
    camera.cx = width * test_random_in(state, 0.4, 0.6);
    camera.cy = height * test_random_in(state, 0.4, 0.6);
    return camera;
}

#endif
