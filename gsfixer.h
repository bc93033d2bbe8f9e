/* gsfixer.h - common ground of the gsfixer toolkit: repair 3D Gaussian Splatting scenes made from few photos
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       In exactly one C (C11) or C++ (C++17) file:
           #define GSFIXER_IMPLEMENTATION      // emits every gsfixer header included below it
           #include "gsfixer_splat.h"          // includes gsfixer.h and gsfixer_traj.h by itself
       Everywhere else include the headers without the define. GSFIXER_BASE_IMPLEMENTATION emits this header
       only. Define GSFIXER_STATIC before every include to make all functions private to one file.

   WHAT IT DOES NOT DO
       It never prints, exits, aborts or keeps global state; it starts no thread of its own.

   CONVENTIONS
       camera axes     OpenCV: x right, y down, z forward
       matrices        double[16], column-major (the layout of glm::dmat4); w2c maps world to camera, c2w back
       pixels          (0,0) is the top left corner of the top left pixel; its centre is (0.5, 0.5). COLMAP cx, cy.
       quaternions     w, x, y, z
       colour          sRGB-coded values as they stand in the photo, [0,1] when float; nothing is linearised
       lengths         those of the scene file
       paths, text     UTF-8

   CONFIGURATION (define before the implementation)
       GSF_NO_STB              no image files through stb (host decodes images itself)
       GSF_STB_IMAGE_INCLUDE / GSF_STB_IMAGE_WRITE_INCLUDE   where stb lies (default <stb/stb_image.h>, ...)
       GSF_USE_OIIO            C++ only: EXR, TIFF, 16-bit files through OpenImageIO
       GSF_USE_GLM             C++ only: adapters to glm matrices (declared as soon as it is defined)
       GSF_ASSERT(x)           default assert(x); only for this library's own bugs
       GSF_NO_SIMD             scalar kernels only

   STEP BY STEP
       gsf_context ctx;
       memset(&ctx, 0, sizeof ctx);                       // all hooks default
       if (gsf_init_context(&ctx) != GSF_OK) ...          // picks CPU level and workers
       gsf_image photo;
       if (gsf_load_image(&ctx, "photo.jpg", 3, &photo) != GSF_OK) puts(ctx.error);
       gsf_destroy_image(&ctx, &photo);

   ERRORS      Every fallible function returns gsf_result; the sentence ("file:offset: expected x, got y") stands in
               ctx->error and goes to the log hook. On error outputs are zeroed or untouched and nothing leaks.
   MEMORY      All memory comes from the context's allocator. Who made an object destroys it with the same context.
   THREADS     One thread at a time per context. Work is split through the parallel hook on a chunk grid that depends
               on sizes only, so results do not depend on the number of workers.
   SECTIONS    >>context >>memory >>parallel >>random >>text >>files >>chunks >>json >>images >>resize >>metrics
               >>cameras >>glm >>oiio
*/
#ifndef GSF_BASE_INCLUDED
#define GSF_BASE_INCLUDED

#include <stddef.h>
#include <stdint.h>

#define GSF_VERSION "0.1.0"

#ifndef GSF_API
#if defined(GSFIXER_STATIC) && (defined(__GNUC__) || defined(__clang__))
#define GSF_API static __attribute__((unused)) // a file need not call all of them
#elif defined(GSFIXER_STATIC)
#define GSF_API static
#else
#define GSF_API extern
#endif
#endif

#if defined(__GNUC__) || defined(__clang__)
#define GSF_NODISCARD __attribute__((warn_unused_result))
#define GSF_RESTRICT __restrict__
#define GSF_PRINTF(fmt, args) __attribute__((format(printf, fmt, args)))
#else
#define GSF_NODISCARD
#define GSF_RESTRICT __restrict
#define GSF_PRINTF(fmt, args)
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---- results -------------------------------------------------------------------

#define GSF_RESULTS(X)                                                     \
    X(GSF_OK, "ok")                                                        \
    X(GSF_ERROR_INVALID_ARGUMENT, "invalid argument")                      \
    X(GSF_ERROR_OUT_OF_MEMORY, "out of memory")                            \
    X(GSF_ERROR_IO, "file cannot be read or written")                      \
    X(GSF_ERROR_FORMAT, "file content is malformed")                       \
    X(GSF_ERROR_UNSUPPORTED, "not supported by this build or version")     \
    X(GSF_ERROR_CANCELLED, "cancelled")                                    \
    X(GSF_ERROR_DEGENERATE, "geometry is degenerate")                      \
    X(GSF_ERROR_NUMERIC, "a value is NaN or infinite")                     \
    X(GSF_ERROR_RESTORER, "the restorer failed")

typedef enum gsf_result {
#define GSF_X(name, text) name,
    GSF_RESULTS(GSF_X)
#undef GSF_X
} gsf_result;

// English text of a result, never NULL.
GSF_API const char* gsf_describe_result(gsf_result result);

// ---- context -------------------------------------------------------------------

typedef struct gsf_context gsf_context;

typedef enum gsf_cpu_level { // instruction sets a kernel may use; AUTO picks the best one of the machine
    GSF_CPU_AUTO = 0,
    GSF_CPU_SCALAR = 1,
    GSF_CPU_AVX2 = 2, // with FMA
} gsf_cpu_level;

typedef enum gsf_log_level { GSF_LOG_ERROR = 0, GSF_LOG_WARNING = 1, GSF_LOG_INFO = 2 } gsf_log_level;

typedef struct gsf_allocator { // both functions or neither (neither: malloc, free)
    void* (*alloc_fn)(void* user, size_t size); // NULL when out of memory
    void (*free_fn)(void* user, void* memory);
    void* user;
} gsf_allocator;

typedef struct gsf_logger {
    void (*log_fn)(void* user, gsf_log_level level, const char* text);
    void* user;
} gsf_logger;

// One unit of parallel work. `worker` is below the hook's worker_count; no two chunks run on one worker at a time.
typedef void (*gsf_chunk_fn)(void* arg, size_t chunk, int worker);

typedef struct gsf_parallel { // run body for chunks 0..chunk_count-1, return when all are done; never nested
    void (*for_fn)(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg);
    int worker_count;
    void* user;
} gsf_parallel;

typedef struct gsf_io { // both or neither (neither: stdio; writes go to a temporary that is then renamed)
    // Reads a whole file. *data comes from ctx->allocator via gsf_alloc and is freed by the library.
    gsf_result (*read_fn)(void* user, gsf_context* ctx, const char* path, void** data, size_t* size);
    gsf_result (*write_fn)(void* user, gsf_context* ctx, const char* path, const void* data, size_t size);
    void* user;
} gsf_io;

typedef struct gsf_progress { // called from the calling thread, at most a few times a second's worth of work
    void (*progress_fn)(void* user, const char* stage, double done, double total);
    void* user;
} gsf_progress;

struct gsf_context {
    gsf_allocator allocator;
    gsf_logger logger;
    gsf_parallel parallel;   // zero: OpenMP where compiled with it, else serial
    gsf_io io;
    gsf_progress progress;
    gsf_cpu_level cpu_level; // in: AUTO or a level to force; out: the level in use
    int threads;             // for the OpenMP default: number of workers, 0 = all cores
    int cancel;              // see gsf_request_cancel
    int initialized;
    char error[512];         // sentence of the last error
};

// Fills in every hook that is zero and resolves cpu_level (lowered, never raised, to what the machine has).
// Call once on a zeroed or filled-in struct. Owns nothing, so there is no counterpart.
GSF_API GSF_NODISCARD gsf_result gsf_init_context(gsf_context* ctx);

// Asks running work to stop at its next safe point with GSF_ERROR_CANCELLED. Safe from signal handlers and other
// threads. Cleared by gsf_clear_cancel.
GSF_API void gsf_request_cancel(gsf_context* ctx);
GSF_API void gsf_clear_cancel(gsf_context* ctx);
GSF_API int gsf_is_cancelled(const gsf_context* ctx);

// Name of an instruction set level ("scalar", "avx2").
GSF_API const char* gsf_cpu_level_name(gsf_cpu_level level);

// Sets ctx->error (printf style), logs it and returns `result`. For hooks and restorers written by the host as well.
GSF_API gsf_result gsf_fail(gsf_context* ctx, gsf_result result, const char* format, ...) GSF_PRINTF(3, 4);
GSF_API void gsf_log(gsf_context* ctx, gsf_log_level level, const char* format, ...) GSF_PRINTF(3, 4);

// Memory from the context's allocator, 64-byte aligned. count*size is checked. NULL (and ctx->error) on failure.
GSF_API void* gsf_alloc(gsf_context* ctx, size_t count, size_t size);
GSF_API void* gsf_alloc_zeroed(gsf_context* ctx, size_t count, size_t size);
GSF_API void gsf_free(gsf_context* ctx, void* memory); // NULL is fine

// ---- random numbers ------------------------------------------------------------
// Counter-based: a pure function of (seed, stream, index), so threads, skipping and resuming change nothing.

GSF_API uint64_t gsf_random_bits(uint64_t seed, uint64_t stream, uint64_t index);
GSF_API double gsf_random_uniform(uint64_t seed, uint64_t stream, uint64_t index); // [0,1)
GSF_API double gsf_random_normal(uint64_t seed, uint64_t stream, uint64_t index);  // mean 0, variance 1

// ---- text and files ------------------------------------------------------------

typedef struct gsf_text { // growing UTF-8 buffer, always zero-terminated once something was added
    char* data;
    size_t size, capacity;
    int failed; // an allocation failed; later calls do nothing
} gsf_text;

GSF_API void gsf_text_printf(gsf_context* ctx, gsf_text* text, const char* format, ...) GSF_PRINTF(3, 4);
GSF_API void gsf_text_append(gsf_context* ctx, gsf_text* text, const char* data, size_t size);
GSF_API void gsf_text_json_string(gsf_context* ctx, gsf_text* text, const char* string); // quoted and escaped
GSF_API void gsf_text_json_number(gsf_context* ctx, gsf_text* text, double value);       // NaN, inf become null
GSF_API void gsf_destroy_text(gsf_context* ctx, gsf_text* text);

// Whole-file input and output through the io hook. `*data` is freed with gsf_free.
// gsf_write_file replaces the file only once everything is written: on a full disk the previous file survives.
GSF_API GSF_NODISCARD gsf_result gsf_read_file(gsf_context* ctx, const char* path, void** data, size_t* size);
GSF_API GSF_NODISCARD gsf_result gsf_write_file(gsf_context* ctx, const char* path, const void* data, size_t size);

/* Tagged chunks, the container of checkpoints. Little-endian:
       char magic[8] "GSFCHUNK" | u32 version
       repeated: char tag[4] | u64 size | bytes[size] | u32 crc32(tag, size, bytes)
       the last chunk is "END " of size 0, so a cut file is noticed. */
typedef struct gsf_chunk {
    char tag[5]; // zero-terminated
    const void* data; // points into the file's buffer; any alignment
    size_t size;
} gsf_chunk;

// Adds a chunk to `out` (which starts as a zeroed gsf_text). Finish with gsf_chunks_end, then gsf_write_file.
GSF_API void gsf_chunks_add(gsf_context* ctx, gsf_text* out, const char* tag, const void* data, size_t size);
GSF_API void gsf_chunks_end(gsf_context* ctx, gsf_text* out);
// Checks a whole file (magic, sizes, checksums, end). `name` is used in error texts.
GSF_API GSF_NODISCARD gsf_result gsf_chunks_check(gsf_context* ctx, const char* name, const void* data, size_t size);
// Finds a chunk in checked data; returns 0 when there is none.
GSF_API int gsf_chunks_find(const void* data, size_t size, const char* tag, gsf_chunk* out);

// ---- JSON ----------------------------------------------------------------------

typedef enum gsf_json_type {
    GSF_JSON_NULL, GSF_JSON_FALSE, GSF_JSON_TRUE, GSF_JSON_NUMBER, GSF_JSON_STRING, GSF_JSON_ARRAY, GSF_JSON_OBJECT
} gsf_json_type;

typedef struct gsf_json_value { // one node; children of arrays and objects follow their parent in document order
    gsf_json_type type;
    uint32_t next;       // index of the next sibling, 0 = none
    uint32_t child;      // index of the first child, 0 = none
    uint32_t count;      // number of children
    uint32_t key_size;   // length of the key in bytes (members of objects)
    uint32_t offset;     // byte offset in the source, for error texts
    const char* key;     // decoded, zero-terminated; NULL outside objects
    const char* string;  // decoded, zero-terminated; strings only
    size_t string_size;
    double number;
} gsf_json_value;

typedef struct gsf_json { // a parsed document; values[0] is the root
    gsf_json_value* values;
    size_t count;
    char* strings;
    char name[128]; // for error texts
} gsf_json;

// RFC 8259, strictly: UTF-8 checked, duplicate keys refused, at most 64 levels deep, finite numbers.
// Takes memory in proportion to the text only.
GSF_API GSF_NODISCARD gsf_result gsf_parse_json(gsf_context* ctx, const char* name, const char* text, size_t size,
                                                gsf_json* out);
GSF_API void gsf_destroy_json(gsf_context* ctx, gsf_json* json);
// Member of an object or NULL (also when `object` is NULL or no object).
GSF_API const gsf_json_value* gsf_json_member(const gsf_json* json, const gsf_json_value* object, const char* key);
// Element of an array or NULL. Linear in index; walk `child` and `next` for long arrays.
GSF_API const gsf_json_value* gsf_json_element(const gsf_json* json, const gsf_json_value* array, size_t index);

// ---- images --------------------------------------------------------------------

typedef enum gsf_dtype { GSF_U8 = 0, GSF_U16, GSF_F16, GSF_F32, GSF_F64 } gsf_dtype;
typedef enum gsf_color_space { GSF_SRGB = 0, GSF_LINEAR } gsf_color_space; // a label; no function converts silently

GSF_API size_t gsf_dtype_size(gsf_dtype dtype);

// A view of pixels. Strides are in bytes, so packed, padded, planar and flipped images are all just views.
// `owned` is non-NULL only in images made by this library, and is what gsf_destroy_image frees.
typedef struct gsf_image {
    void* data;
    gsf_dtype dtype;
    gsf_color_space color_space;
    int64_t width, height;
    int32_t channels;
    int64_t stride_x, stride_y, stride_c;
    void* owned;
} gsf_image;

// View of caller memory, rows packed, channels interleaved (H,W,C).
GSF_API gsf_image gsf_wrap_image(void* data, gsf_dtype dtype, int64_t width, int64_t height, int32_t channels);
// Packed image with zeroed pixels.
GSF_API GSF_NODISCARD gsf_result gsf_make_image(gsf_context* ctx, gsf_dtype dtype, int64_t width, int64_t height,
                                                int32_t channels, gsf_image* out);
GSF_API void gsf_destroy_image(gsf_context* ctx, gsf_image* image);

// Copies pixels between dtypes and layouts. u8 to float divides by 255; float to u8 is clamp(x*255 + 0.5) truncated
// (torchvision save_image); NaN becomes 0. 1 channel spreads to 3; 4 to 3 drops alpha; other counts are an error.
GSF_API GSF_NODISCARD gsf_result gsf_convert_image(gsf_context* ctx, const gsf_image* src, const gsf_image* dst);

// Reads PNG, JPEG, BMP, TGA, PNM (stb) and, with GSF_USE_OIIO, whatever OpenImageIO reads. channels: 1, 3, 4 or
// 0 = as in the file. Result is u8 (stb), or u8, u16, f16, f32 as in the file (OpenImageIO).
GSF_API GSF_NODISCARD gsf_result gsf_load_image(gsf_context* ctx, const char* path, int32_t channels, gsf_image* out);
GSF_API GSF_NODISCARD gsf_result gsf_load_image_memory(gsf_context* ctx, const char* name, const void* data,
                                                       size_t size, int32_t channels, gsf_image* out);
// Reads only the header.
GSF_API GSF_NODISCARD gsf_result gsf_query_image(gsf_context* ctx, const char* path, int64_t* width, int64_t* height,
                                                 int32_t* channels);
// Writes by extension: .png (u8, from any dtype), .jpg (quality 95) and, with GSF_USE_OIIO, .exr .tif (dtype kept).
GSF_API GSF_NODISCARD gsf_result gsf_save_image(gsf_context* ctx, const char* path, const gsf_image* image);
// PNG or JPEG bytes in memory (reports embed them). `extension` is ".png" or ".jpg".
GSF_API GSF_NODISCARD gsf_result gsf_encode_image(gsf_context* ctx, const gsf_image* image, const char* extension,
                                                  gsf_text* out);

typedef enum gsf_resize_filter {
    GSF_RESIZE_PIL_BILINEAR,   // PIL.Image.resize: antialiased when shrinking, u8 in two integer passes, bit-exact
    GSF_RESIZE_PIL_BICUBIC,    //   (a = -0.5)
    GSF_RESIZE_PIL_LANCZOS,    //   (a = 3)
    GSF_RESIZE_TORCH_BILINEAR, // F.interpolate(bilinear, align_corners=False, antialias=False), f32
} gsf_resize_filter;

// Resizes src into dst (sizes taken from the views; same dtype and channels; PIL: u8 or f32; torch: f32).
GSF_API GSF_NODISCARD gsf_result gsf_resize_image(gsf_context* ctx, const gsf_image* src, gsf_resize_filter filter,
                                                  const gsf_image* dst);

// ---- pixel metrics -------------------------------------------------------------

typedef enum gsf_ssim_kind {
    GSF_SSIM_3DGS,         // 11x11 Gaussian sigma 1.5, zero padding, variances not clamped: the 3DGS papers' figure
    GSF_SSIM_TORCHMETRICS, // the same kernel, reflect padding, variances clamped at 0 (gsplat's trainer)
    GSF_SSIM_SKIMAGE,      // scikit-image's default: 7x7 uniform window, sample covariance, mean over the valid inside
} gsf_ssim_kind;

// Images u8 or f32 (values in [0,1] when f32), equal sizes and channels. Double accumulation in a fixed order.
// mask: NULL, or u8 one-channel of the same size; only pixels with mask != 0 count (for SSIM: mean of the SSIM map over
// them). With no pixel to count the result is GSF_ERROR_DEGENERATE. PSNR of identical images is +infinity.
GSF_API GSF_NODISCARD gsf_result gsf_psnr(gsf_context* ctx, const gsf_image* a, const gsf_image* b,
                                          const gsf_image* mask, double* out);
GSF_API GSF_NODISCARD gsf_result gsf_ssim(gsf_context* ctx, gsf_ssim_kind kind, const gsf_image* a, const gsf_image* b,
                                          const gsf_image* mask, double* out);

// ---- cameras -------------------------------------------------------------------

typedef struct gsf_camera { // pinhole: u = fx X/Z + cx, v = fy Y/Z + cy with (X,Y,Z) = w2c (x,y,z,1)
    double w2c[16];         // column-major rigid transform
    double fx, fy, cx, cy;  // pixels
    int32_t width, height;
} gsf_camera;

// Finite, rigid (1e-4), positive focal lengths and size? Otherwise the error names the entry.
GSF_API GSF_NODISCARD gsf_result gsf_check_camera(gsf_context* ctx, const gsf_camera* camera);
GSF_API void gsf_camera_center(const gsf_camera* camera, double center[3]);
GSF_API void gsf_camera_c2w(const gsf_camera* camera, double c2w[16]);
GSF_API void gsf_camera_set_c2w(gsf_camera* camera, const double c2w[16]); // inverts a rigid transform
// World point to pixel and camera depth. Returns 0 (u, v untouched) where depth <= 0.
GSF_API int gsf_camera_project(const gsf_camera* camera, const double point[3], double* u, double* v, double* depth);
// The same view in another image size; intrinsics scale with width and height separately.
GSF_API gsf_camera gsf_camera_resized(const gsf_camera* camera, int32_t width, int32_t height);
// out = a * b for column-major 4x4.
GSF_API void gsf_mat4_mul(const double a[16], const double b[16], double out[16]);
// Inverse of a rigid transform (rotation transposed).
GSF_API void gsf_mat4_rigid_inverse(const double m[16], double out[16]);

// JSON list of cameras ({"cameras":[{"name","w2c":[16 numbers, row-major],"fx","fy","cx","cy","width","height"}]}),
// the format of `gsfix path`, `gsfix render --path` and a restorer job's cameras.json. Names may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_save_cameras(gsf_context* ctx, const char* path, const gsf_camera* cameras,
                                                  const char* const* names, size_t count);
// *cameras is freed with gsf_free.
GSF_API GSF_NODISCARD gsf_result gsf_load_cameras(gsf_context* ctx, const char* path, gsf_camera** cameras,
                                                  size_t* count);

// ---- restorer interface --------------------------------------------------------
// What turns artifact-ridden renders into clean frames. The repair loop of gsfixer_splat.h sees only this struct; a host
// fills in its own functions, or takes one of the toolkit's (warp in gsfixer_splat.h, the video model in gsfixer_nn.h).

typedef struct gsf_restorer_limits { // what a restorer accepts; zero = any
    int32_t frame_count_min, frame_count_max;
    int32_t frame_count_step;       // legal counts: min, min + step, ... up to max
    int32_t width_multiple, height_multiple;
    int32_t width_max, height_max;
    int32_t needs_depth, needs_alpha, needs_caption;
    double bytes, flops;            // estimate for one window of the queried size; 0 = unknown
} gsf_restorer_limits;

typedef struct gsf_reference { // a photo the scene was trained on
    gsf_image color;  // f32, 3 channels
    gsf_image depth;  // f32 camera depth rendered from the splats, 0 = nothing there; data NULL unless needs_depth
    gsf_camera camera;
} gsf_reference;

typedef struct gsf_restore_window { // one clip; all pointers are borrowed for the call
    uint32_t struct_size;
    int32_t frame_count;
    const gsf_image* color;           // f32, 3 channels, [0,1]; all of one size
    const gsf_image* depth;           // f32, 1 channel: expected camera depth, 0 = nothing; NULL unless needs_depth
    const gsf_image* alpha;           // f32, 1 channel: 1 - transmittance; NULL unless needs_alpha
    const gsf_camera* cameras;
    const int32_t* reference_index;   // per frame: this frame IS that reference's view, or -1
    const char* caption;              // NULL = none
    uint64_t seed;
    gsf_image* out_color;             // f32, 3 channels, same size; written by the restorer
    gsf_image* out_confidence;        // f32, 1 channel, [0,1]; weight of each restored pixel in training
} gsf_restore_window;

typedef struct gsf_restorer {
    uint32_t struct_size; // sizeof(gsf_restorer) of the caller, so that fields can be added
    const char* name;
    void* user;
    gsf_result (*query_fn)(void* user, gsf_context* ctx, int32_t frame_count, int32_t width, int32_t height,
                           gsf_restorer_limits* out);
    gsf_result (*begin_fn)(void* user, gsf_context* ctx, const gsf_reference* references, int32_t reference_count);
    gsf_result (*restore_fn)(void* user, gsf_context* ctx, const gsf_restore_window* window);
    void (*end_fn)(void* user, gsf_context* ctx); // releases what begin took; called once per successful begin
} gsf_restorer;

#ifdef __cplusplus
}
#endif

#endif // GSF_BASE_INCLUDED

// ================================================================================
// The API ends here. What follows is the implementation.
// ================================================================================

// ---- >>internals: what every module's implementation shares ---------------------

#if defined(GSFIXER_IMPLEMENTATION) || defined(GSFIXER_BASE_IMPLEMENTATION) ||                        \
    defined(GSFIXER_TRAJ_IMPLEMENTATION) || defined(GSFIXER_SPLAT_IMPLEMENTATION) ||                  \
    defined(GSFIXER_NN_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_INTERNALS_INCLUDED
#define GSF_INTERNALS_INCLUDED

#include <errno.h>
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifndef GSF_ASSERT
#include <assert.h>
#define GSF_ASSERT(x) assert(x)
#endif

#if !defined(GSF_NO_SIMD) && defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
#define GSF__X86 1
#include <immintrin.h>
#define GSF__TARGET_AVX2 __attribute__((target("avx2,fma,f16c")))
#else
#define GSF__X86 0
#endif

#ifdef _OPENMP
#include <omp.h>
#endif

// Between these two, multiplications and additions round separately unless an FMA is written out, so that C11 and
// C++17 builds and all compilers agree; the includer's mode is restored. Every implementation stands between them.
#if defined(__clang__)
#define GSF__BEGIN_IMPLEMENTATION _Pragma("STDC FP_CONTRACT OFF")
#define GSF__END_IMPLEMENTATION _Pragma("STDC FP_CONTRACT DEFAULT")
#elif defined(__GNUC__)
#define GSF__BEGIN_IMPLEMENTATION _Pragma("GCC push_options") _Pragma("GCC optimize(\"fp-contract=off\")")
#define GSF__END_IMPLEMENTATION _Pragma("GCC pop_options")
#else
#define GSF__BEGIN_IMPLEMENTATION
#define GSF__END_IMPLEMENTATION
#endif

#if defined(__GNUC__) || defined(__clang__)
#define GSF__SHARED static __attribute__((unused)) // a translation unit need not use all of them
#define GSF__ATOMIC_LOAD(p) __atomic_load_n((p), __ATOMIC_RELAXED)
#define GSF__ATOMIC_STORE(p, v) __atomic_store_n((p), (v), __ATOMIC_RELAXED)
#else
#define GSF__SHARED static
#define GSF__ATOMIC_LOAD(p) (*(volatile const int*)(p))
#define GSF__ATOMIC_STORE(p, v) (*(volatile int*)(p) = (v))
#endif

#define GSF__TRY(call)                                         \
    do {                                                       \
        const gsf_result gsf__try_result = (call);             \
        if (gsf__try_result != GSF_OK) return gsf__try_result; \
    } while (0)

#define GSF__COUNT(array) (sizeof(array) / sizeof((array)[0]))

GSF__BEGIN_IMPLEMENTATION

GSF__SHARED gsf_result gsf__check_cancel(gsf_context* ctx) {
    return gsf_is_cancelled(ctx) ? gsf_fail(ctx, GSF_ERROR_CANCELLED, "cancelled") : GSF_OK;
}

GSF__SHARED void gsf__progress(gsf_context* ctx, const char* stage, double done, double total) {
    if (ctx->progress.progress_fn) ctx->progress.progress_fn(ctx->progress.user, stage, done, total);
}

// out = a * b; 0 on overflow.
GSF__SHARED int gsf__mul_size(size_t a, size_t b, size_t* out) {
    if (b != 0 && a > SIZE_MAX / b) return 0;
    *out = a * b;
    return 1;
}

// Grows *array (of `size`-byte elements) so that it holds at least `needed`; keeps `used` elements.
GSF__SHARED gsf_result gsf__reserve(gsf_context* ctx, void** array, size_t* capacity, size_t used, size_t needed,
                               size_t size) {
    if (needed <= *capacity) return GSF_OK;
    size_t grown = *capacity + *capacity / 2 + 16;
    if (grown < needed) grown = needed;
    void* fresh = gsf_alloc(ctx, grown, size);
    if (!fresh) return GSF_ERROR_OUT_OF_MEMORY;
    if (used) memcpy(fresh, *array, used * size);
    gsf_free(ctx, *array);
    *array = fresh;
    *capacity = grown;
    return GSF_OK;
}

GSF__SHARED void gsf__for_serial(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    (void)user;
    for (size_t i = 0; i < chunk_count; i++) body(arg, i, 0);
}

GSF__SHARED void gsf__parallel_for(gsf_context* ctx, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    if (chunk_count == 0) return;
    if (chunk_count == 1 || ctx->parallel.worker_count == 1) {
        gsf__for_serial(NULL, chunk_count, body, arg);
        return;
    }
    ctx->parallel.for_fn(ctx->parallel.user, chunk_count, body, arg);
}

GSF__SHARED uint64_t gsf__load_le(const void* data, int bytes) {
    const unsigned char* p = (const unsigned char*)data;
    uint64_t value = 0;
    for (int i = bytes - 1; i >= 0; i--) value = value << 8 | p[i];
    return value;
}

GSF__SHARED void gsf__store_le(void* data, uint64_t value, int bytes) {
    unsigned char* p = (unsigned char*)data;
    for (int i = 0; i < bytes; i++, value >>= 8) p[i] = (unsigned char)(value & 255u);
}

GSF__SHARED void gsf__camera_transform(const gsf_camera* camera, const double point[3], double out[3]) {
    const double* m = camera->w2c;
    for (int r = 0; r < 3; r++) out[r] = m[r] * point[0] + m[4 + r] * point[1] + m[8 + r] * point[2] + m[12 + r];
}

GSF__END_IMPLEMENTATION

#endif // GSF_INTERNALS_INCLUDED
#endif

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_BASE_IMPLEMENTATION)
#define GSFIXER_BASE_IMPLEMENTATION
#endif
#if defined(GSFIXER_BASE_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_BASE_IMPLEMENTED
#define GSF_BASE_IMPLEMENTED

GSF__BEGIN_IMPLEMENTATION

// ---- >>context -----------------------------------------------------------------

GSF_API const char* gsf_describe_result(gsf_result result) {
    switch (result) {
#define GSF_X(name, text) case name: return text;
        GSF_RESULTS(GSF_X)
#undef GSF_X
    }
    return "unknown result";
}

GSF_API const char* gsf_cpu_level_name(gsf_cpu_level level) {
    switch (level) {
        case GSF_CPU_AUTO: return "auto";
        case GSF_CPU_SCALAR: return "scalar";
        case GSF_CPU_AVX2: return "avx2";
    }
    return "unknown";
}

static gsf_cpu_level gsf__detect_cpu_level(void) {
#if GSF__X86
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return GSF_CPU_AVX2;
#endif
    return GSF_CPU_SCALAR;
}

GSF_API void gsf_log(gsf_context* ctx, gsf_log_level level, const char* format, ...) {
    if (!ctx->logger.log_fn) return;
    char text[1024];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    ctx->logger.log_fn(ctx->logger.user, level, text);
}

GSF_API gsf_result gsf_fail(gsf_context* ctx, gsf_result result, const char* format, ...) {
    char text[sizeof ctx->error]; // arguments may point into ctx->error
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    memcpy(ctx->error, text, sizeof text);
    if (ctx->logger.log_fn) ctx->logger.log_fn(ctx->logger.user, GSF_LOG_ERROR, ctx->error);
    return result;
}

GSF_API void gsf_request_cancel(gsf_context* ctx) { GSF__ATOMIC_STORE(&ctx->cancel, 1); }
GSF_API void gsf_clear_cancel(gsf_context* ctx) { GSF__ATOMIC_STORE(&ctx->cancel, 0); }
GSF_API int gsf_is_cancelled(const gsf_context* ctx) { return GSF__ATOMIC_LOAD(&ctx->cancel) != 0; }

// ---- >>memory ------------------------------------------------------------------

static void* gsf__malloc(void* user, size_t size) { (void)user; return malloc(size); }
static void gsf__mfree(void* user, void* memory) { (void)user; free(memory); }

enum { GSF__ALIGN = 64 };

GSF_API void* gsf_alloc(gsf_context* ctx, size_t count, size_t size) {
    size_t bytes;
    if (!gsf__mul_size(count, size, &bytes) || bytes > SIZE_MAX - 2 * GSF__ALIGN) {
        (void)gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "out of memory: %zu x %zu bytes", count, size);
        return NULL;
    }
    // [padding][pointer given by the hook][aligned block]
    char* base = (char*)ctx->allocator.alloc_fn(ctx->allocator.user, bytes + GSF__ALIGN + sizeof(void*));
    if (!base) {
        (void)gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "out of memory: %zu bytes", bytes);
        return NULL;
    }
    uintptr_t start = (uintptr_t)base + sizeof(void*);
    char* block = base + sizeof(void*) + ((GSF__ALIGN - start % GSF__ALIGN) % GSF__ALIGN);
    memcpy(block - sizeof(void*), &base, sizeof base);
    return block;
}

GSF_API void* gsf_alloc_zeroed(gsf_context* ctx, size_t count, size_t size) {
    void* block = gsf_alloc(ctx, count, size);
    if (block) memset(block, 0, count * size);
    return block;
}

GSF_API void gsf_free(gsf_context* ctx, void* memory) {
    if (!memory) return;
    void* base;
    memcpy(&base, (char*)memory - sizeof(void*), sizeof base);
    ctx->allocator.free_fn(ctx->allocator.user, base);
}

// ---- >>parallel ----------------------------------------------------------------

#ifdef _OPENMP
static void gsf__for_openmp(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg) {
    const gsf_context* ctx = (const gsf_context*)user;
    const int64_t count = (int64_t)chunk_count;
#pragma omp parallel for schedule(dynamic, 1) num_threads(ctx->parallel.worker_count)
    for (int64_t i = 0; i < count; i++) body(arg, (size_t)i, omp_get_thread_num());
}
#endif

static gsf_result gsf__stdio_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size);
static gsf_result gsf__stdio_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size);

GSF_API gsf_result gsf_init_context(gsf_context* ctx) {
    if (!ctx) return GSF_ERROR_INVALID_ARGUMENT;
    ctx->error[0] = 0;
    if (!ctx->allocator.alloc_fn != !ctx->allocator.free_fn)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "allocator: set both functions or neither");
    if (!ctx->io.read_fn != !ctx->io.write_fn)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "io: set both functions or neither");
    if (ctx->parallel.for_fn && ctx->parallel.worker_count < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "parallel: worker_count is %d", ctx->parallel.worker_count);
    if (ctx->threads < 0) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "threads is %d", ctx->threads);
    if (!ctx->allocator.alloc_fn) {
        ctx->allocator.alloc_fn = gsf__malloc;
        ctx->allocator.free_fn = gsf__mfree;
    }
    if (!ctx->io.read_fn) {
        ctx->io.read_fn = gsf__stdio_read;
        ctx->io.write_fn = gsf__stdio_write;
    }
    if (!ctx->parallel.for_fn) {
#ifdef _OPENMP
        ctx->parallel.for_fn = gsf__for_openmp;
        ctx->parallel.user = ctx;
        ctx->parallel.worker_count = ctx->threads ? ctx->threads : omp_get_max_threads();
#else
        ctx->parallel.for_fn = gsf__for_serial;
        ctx->parallel.worker_count = 1;
#endif
    }
    const gsf_cpu_level best = gsf__detect_cpu_level();
    if (ctx->cpu_level == GSF_CPU_AUTO || ctx->cpu_level > best) ctx->cpu_level = best;
    ctx->initialized = 1;
    return GSF_OK;
}

// ---- >>random ------------------------------------------------------------------

// Three rounds of the splitmix64 finaliser (Steele et al. 2014), one key word mixed in before each.
static uint64_t gsf__mix64(uint64_t x) {
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

GSF_API uint64_t gsf_random_bits(uint64_t seed, uint64_t stream, uint64_t index) {
    uint64_t x = gsf__mix64(seed + 0x9e3779b97f4a7c15u);
    x = gsf__mix64(x ^ (stream * 0xd1342543de82ef95u + 0x2545f4914f6cdd1du));
    return gsf__mix64(x ^ (index * 0x9e3779b97f4a7c15u + 0x632be59bd9b4e019u));
}

GSF_API double gsf_random_uniform(uint64_t seed, uint64_t stream, uint64_t index) {
    return (double)(gsf_random_bits(seed, stream, index) >> 11) * (1.0 / 9007199254740992.0);
}

GSF_API double gsf_random_normal(uint64_t seed, uint64_t stream, uint64_t index) { // Box-Muller
    const double u = 1.0 - gsf_random_uniform(seed, stream, 2 * index);
    const double v = gsf_random_uniform(seed, stream, 2 * index + 1);
    return sqrt(-2.0 * log(u)) * cos(6.283185307179586 * v);
}

// ---- >>text --------------------------------------------------------------------

GSF_API void gsf_text_append(gsf_context* ctx, gsf_text* text, const char* data, size_t size) {
    if (text->failed) return;
    if (size > SIZE_MAX - text->size - 1 ||
        gsf__reserve(ctx, (void**)&text->data, &text->capacity, text->size, text->size + size + 1, 1) != GSF_OK) {
        text->failed = 1;
        return;
    }
    if (size) memcpy(text->data + text->size, data, size);
    text->size += size;
    text->data[text->size] = 0;
}

GSF_API void gsf_text_printf(gsf_context* ctx, gsf_text* text, const char* format, ...) {
    va_list args, again;
    va_start(args, format);
    va_copy(again, args);
    char small[512];
    const int length = vsnprintf(small, sizeof small, format, args);
    va_end(args);
    if (length < 0) {
        text->failed = 1;
    } else if ((size_t)length < sizeof small) {
        gsf_text_append(ctx, text, small, (size_t)length);
    } else if (!text->failed) {
        if (gsf__reserve(ctx, (void**)&text->data, &text->capacity, text->size, text->size + (size_t)length + 1, 1) ==
            GSF_OK) {
            vsnprintf(text->data + text->size, (size_t)length + 1, format, again);
            text->size += (size_t)length;
        } else {
            text->failed = 1;
        }
    }
    va_end(again);
}

GSF_API void gsf_text_json_string(gsf_context* ctx, gsf_text* text, const char* string) {
    gsf_text_append(ctx, text, "\"", 1);
    for (const char* p = string ? string : ""; *p; p++) {
        const unsigned char c = (unsigned char)*p;
        if (c == '"' || c == '\\') gsf_text_printf(ctx, text, "\\%c", c);
        else if (c < 0x20) gsf_text_printf(ctx, text, "\\u%04x", (unsigned)c);
        else gsf_text_append(ctx, text, p, 1);
    }
    gsf_text_append(ctx, text, "\"", 1);
}

GSF_API void gsf_text_json_number(gsf_context* ctx, gsf_text* text, double value) {
    if (isfinite(value)) gsf_text_printf(ctx, text, "%.17g", value);
    else gsf_text_append(ctx, text, "null", 4);
}

GSF_API void gsf_destroy_text(gsf_context* ctx, gsf_text* text) {
    gsf_free(ctx, text->data);
    memset(text, 0, sizeof *text);
}

// ---- >>files -------------------------------------------------------------------

static gsf_result gsf__stdio_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    (void)user;
    FILE* file = fopen(path, "rb");
    if (!file) return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
    gsf_text buffer;
    memset(&buffer, 0, sizeof buffer);
    gsf_result result = GSF_OK;
    size_t step = 1 << 16;
    if (fseek(file, 0, SEEK_END) == 0) { // sized at once where the file can tell; pipes simply grow
        const long end = ftell(file);
        if (end > 0) step = (size_t)end;
        rewind(file);
    }
    for (;;) {
        result = gsf__reserve(ctx, (void**)&buffer.data, &buffer.capacity, buffer.size, buffer.size + step + 1, 1);
        if (result != GSF_OK) break;
        const size_t got = fread(buffer.data + buffer.size, 1, step, file);
        buffer.size += got;
        if (got < step) {
            if (ferror(file)) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
            break;
        }
        step = 1 << 16;
    }
    fclose(file);
    if (result != GSF_OK) {
        gsf_destroy_text(ctx, &buffer);
        return result;
    }
    buffer.data[buffer.size] = 0;
    *data = buffer.data;
    *size = buffer.size;
    return GSF_OK;
}

static gsf_result gsf__stdio_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user;
    gsf_text name;
    memset(&name, 0, sizeof name);
    gsf_text_printf(ctx, &name, "%s.tmp", path);
    if (name.failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = GSF_OK;
    FILE* file = fopen(name.data, "wb");
    if (!file) {
        result = gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", name.data, strerror(errno));
    } else {
        int ok = fwrite(data, 1, size, file) == size && fflush(file) == 0;
        ok = (fclose(file) == 0) && ok;
        if (ok && rename(name.data, path) != 0) {
#ifdef _WIN32 // rename does not replace there
            ok = remove(path) == 0 && rename(name.data, path) == 0;
#else
            ok = 0;
#endif
        }
        if (!ok) {
            result = gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, strerror(errno));
            remove(name.data);
        }
    }
    gsf_destroy_text(ctx, &name);
    return result;
}

GSF_API gsf_result gsf_read_file(gsf_context* ctx, const char* path, void** data, size_t* size) {
    *data = NULL;
    *size = 0;
    return ctx->io.read_fn(ctx->io.user, ctx, path, data, size);
}

GSF_API gsf_result gsf_write_file(gsf_context* ctx, const char* path, const void* data, size_t size) {
    return ctx->io.write_fn(ctx->io.user, ctx, path, data, size);
}

// ---- >>chunks ------------------------------------------------------------------

static uint32_t gsf__crc32(uint32_t crc, const void* data, size_t size) { // reflected 0xedb88320, 4 bits at a time
    static const uint32_t table[16] = {0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u,
                                       0x4db26158u, 0x5005713cu, 0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
                                       0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
    const unsigned char* p = (const unsigned char*)data;
    crc = ~crc;
    for (size_t i = 0; i < size; i++) {
        crc = table[(crc ^ p[i]) & 15u] ^ (crc >> 4);
        crc = table[(crc ^ (uint32_t)(p[i] >> 4)) & 15u] ^ (crc >> 4);
    }
    return ~crc;
}

enum { GSF__CHUNK_FILE_HEAD = 12, GSF__CHUNK_HEAD = 12, GSF__CHUNK_TAIL = 4 };

GSF_API void gsf_chunks_add(gsf_context* ctx, gsf_text* out, const char* tag, const void* data, size_t size) {
    char head[GSF__CHUNK_HEAD];
    if (out->size == 0) {
        memcpy(head, "GSFCHUNK", 8);
        gsf__store_le(head + 8, 1, 4);
        gsf_text_append(ctx, out, head, GSF__CHUNK_FILE_HEAD);
    }
    memcpy(head, tag, 4);
    gsf__store_le(head + 4, size, 8);
    gsf_text_append(ctx, out, head, GSF__CHUNK_HEAD);
    gsf_text_append(ctx, out, (const char*)data, size);
    gsf__store_le(head, gsf__crc32(gsf__crc32(0, head, GSF__CHUNK_HEAD), data, size), 4);
    gsf_text_append(ctx, out, head, GSF__CHUNK_TAIL);
}

GSF_API void gsf_chunks_end(gsf_context* ctx, gsf_text* out) { gsf_chunks_add(ctx, out, "END ", "", 0); }

GSF_API gsf_result gsf_chunks_check(gsf_context* ctx, const char* name, const void* data, size_t size) {
    const char* p = (const char*)data;
    if (size < GSF__CHUNK_FILE_HEAD || memcmp(p, "GSFCHUNK", 8) != 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: not a checkpoint (magic GSFCHUNK expected)", name);
    if (gsf__load_le(p + 8, 4) != 1)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:8: checkpoint version %u, this program reads 1", name,
                        (unsigned)gsf__load_le(p + 8, 4));
    for (size_t at = GSF__CHUNK_FILE_HEAD;;) {
        if (size - at < GSF__CHUNK_HEAD + GSF__CHUNK_TAIL)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file is cut (no END chunk)", name, at);
        const uint64_t bytes = gsf__load_le(p + at + 4, 8);
        if (bytes > size - at - GSF__CHUNK_HEAD - GSF__CHUNK_TAIL)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: chunk of %llu bytes does not fit the file", name, at,
                            (unsigned long long)bytes);
        const char* body = p + at + GSF__CHUNK_HEAD;
        if (gsf__crc32(gsf__crc32(0, p + at, GSF__CHUNK_HEAD), body, (size_t)bytes) !=
            (uint32_t)gsf__load_le(body + bytes, 4))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: checksum mismatch", name, at);
        if (memcmp(p + at, "END ", 4) == 0) return GSF_OK;
        at += GSF__CHUNK_HEAD + (size_t)bytes + GSF__CHUNK_TAIL;
    }
}

GSF_API int gsf_chunks_find(const void* data, size_t size, const char* tag, gsf_chunk* out) {
    const char* p = (const char*)data;
    memset(out, 0, sizeof *out);
    for (size_t at = GSF__CHUNK_FILE_HEAD; size - at >= GSF__CHUNK_HEAD && memcmp(p + at, "END ", 4) != 0;) {
        const size_t bytes = (size_t)gsf__load_le(p + at + 4, 8);
        if (memcmp(p + at, tag, 4) == 0) {
            memcpy(out->tag, tag, 4);
            out->data = p + at + GSF__CHUNK_HEAD;
            out->size = bytes;
            return 1;
        }
        at += GSF__CHUNK_HEAD + bytes + GSF__CHUNK_TAIL;
    }
    return 0;
}

// ---- >>json --------------------------------------------------------------------

// ---- >>images ------------------------------------------------------------------

// ---- >>resize ------------------------------------------------------------------

// ---- >>metrics -----------------------------------------------------------------

// ---- >>cameras -----------------------------------------------------------------

GSF_API void gsf_mat4_mul(const double a[16], const double b[16], double out[16]) {
    double m[16];
    for (int c = 0; c < 4; c++)
        for (int r = 0; r < 4; r++) {
            double sum = 0.0;
            for (int k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
            m[4 * c + r] = sum;
        }
    memcpy(out, m, sizeof m);
}

GSF_API void gsf_mat4_rigid_inverse(const double m[16], double out[16]) {
    double inv[16];
    for (int c = 0; c < 3; c++) {
        for (int r = 0; r < 3; r++) inv[4 * c + r] = m[4 * r + c];
        inv[4 * c + 3] = 0.0;
    }
    for (int r = 0; r < 3; r++) inv[12 + r] = -(m[4 * r] * m[12] + m[4 * r + 1] * m[13] + m[4 * r + 2] * m[14]);
    inv[15] = 1.0;
    memcpy(out, inv, sizeof inv);
}

GSF_API void gsf_camera_center(const gsf_camera* camera, double center[3]) {
    double c2w[16];
    gsf_mat4_rigid_inverse(camera->w2c, c2w);
    memcpy(center, c2w + 12, 3 * sizeof(double));
}

GSF_API void gsf_camera_c2w(const gsf_camera* camera, double c2w[16]) { gsf_mat4_rigid_inverse(camera->w2c, c2w); }
GSF_API void gsf_camera_set_c2w(gsf_camera* camera, const double c2w[16]) { gsf_mat4_rigid_inverse(c2w, camera->w2c); }

GSF_API int gsf_camera_project(const gsf_camera* camera, const double point[3], double* u, double* v, double* depth) {
    double p[3];
    gsf__camera_transform(camera, point, p);
    *depth = p[2];
    if (!(p[2] > 0.0)) return 0;
    *u = camera->fx * p[0] / p[2] + camera->cx;
    *v = camera->fy * p[1] / p[2] + camera->cy;
    return 1;
}

GSF_API gsf_camera gsf_camera_resized(const gsf_camera* camera, int32_t width, int32_t height) {
    gsf_camera out = *camera;
    const double sx = (double)width / camera->width, sy = (double)height / camera->height;
    out.fx *= sx;
    out.cx *= sx;
    out.fy *= sy;
    out.cy *= sy;
    out.width = width;
    out.height = height;
    return out;
}

GSF_API gsf_result gsf_check_camera(gsf_context* ctx, const gsf_camera* camera) {
    const double* m = camera->w2c;
    for (int i = 0; i < 16; i++)
        if (!isfinite(m[i])) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "camera: w2c[%d] is not finite", i);
    for (int a = 0; a < 3; a++)
        for (int b = a; b < 3; b++) {
            const double dot = m[4 * a] * m[4 * b] + m[4 * a + 1] * m[4 * b + 1] + m[4 * a + 2] * m[4 * b + 2];
            if (fabs(dot - (a == b)) > 1e-4)
                return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "camera: w2c is not rigid (columns %d, %d)", a, b);
        }
    if (m[3] != 0.0 || m[7] != 0.0 || m[11] != 0.0 || fabs(m[15] - 1.0) > 1e-12)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "camera: last row of w2c is not 0 0 0 1");
    if (!(camera->fx > 0.0 && camera->fy > 0.0 && isfinite(camera->fx) && isfinite(camera->fy)))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "camera: focal length %g, %g", camera->fx, camera->fy);
    if (!isfinite(camera->cx) || !isfinite(camera->cy))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "camera: principal point %g, %g", camera->cx, camera->cy);
    if (camera->width < 1 || camera->height < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "camera: image size %d x %d", (int)camera->width,
                        (int)camera->height);
    return GSF_OK;
}

// ---- >>glm ---------------------------------------------------------------------

// ---- >>oiio --------------------------------------------------------------------

GSF__END_IMPLEMENTATION

#endif // GSF_BASE_IMPLEMENTED
#endif // GSFIXER_BASE_IMPLEMENTATION
