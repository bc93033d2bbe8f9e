/* gsfixer.h - shared foundation of the gsfixer toolkit, which repairs 3D Gaussian Splatting scenes made from few photos
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       In exactly one C (C11) or C++ (C++17) file:
           #define GSFIXER_IMPLEMENTATION      // emits every gsfixer header included below it
           #include "gsfixer_splat.h"          // includes gsfixer.h and gsfixer_traj.h by itself
       Everywhere else include the headers without the define. GSFIXER_BASE_IMPLEMENTATION emits this header
       only. Define GSFIXER_STATIC before every include to make all functions private to one file.

   WHAT IT DOES NOT DO
       It never prints, exits, aborts or keeps global state. It starts no threads except through OpenMP, if compiled
       with it and the host sets no parallel hook.

   CONVENTIONS
       camera axes     OpenCV: x right, y down, z forward
       matrices        double[16], column-major (the layout of glm::dmat4); w2c maps world to camera, c2w back
       pixels          (0,0) is the top left corner of the top left pixel; its centre is (0.5, 0.5). COLMAP cx, cy.
       quaternions     w, x, y, z
       colour          sRGB-encoded values as in the photo, [0,1] if float; nothing is linearised
       lengths         in the units of the scene file
       paths, text     UTF-8

   CONFIGURATION (define before the implementation)
       GSF_NO_STB              no stb: the host decodes images, .spz cannot be read; PNG can still be written
       GSF_STB_IMAGE_INCLUDE / GSF_STB_IMAGE_WRITE_INCLUDE   paths of stb (default <stb/stb_image.h>, ...)
       GSF_USE_OIIO            C++ only: EXR, TIFF and 16-bit files through OpenImageIO
       GSF_USE_GLM             C++ only: adapters to glm matrices (define it before every include)
       GSF_ASSERT(x)           default assert(x); used only to detect bugs of this library
       GSF_NO_SIMD             scalar kernels only
       GSF_NO_AVX512           no AVX-512: a tenth smaller, faster to compile

   STEP BY STEP
       gsf_context ctx;
       memset(&ctx, 0, sizeof ctx);                       // all hooks default
       if (gsf_init_context(&ctx) != GSF_OK) ...          // picks CPU level and workers
       gsf_image photo;
       if (gsf_load_image(&ctx, "photo.jpg", 3, &photo) != GSF_OK) puts(ctx.error);
       gsf_destroy_image(&ctx, &photo);

   ERRORS      Every fallible function returns gsf_result; the message ("file:offset: expected x, got y") is stored in
               ctx->error and passed to the log hook. On error, outputs are zeroed or unchanged and nothing leaks.
   MEMORY      All memory comes from the context's allocator. The caller that makes an object destroys it with the same
               context.
   STACK       No function's own frame is above 16 KB with -O2 or -O3, nor above 17 KB with -O0 (tests/stack.sh), so threads
               with 256 KB are enough.
   PLATFORMS   64-bit Linux, Windows (MinGW-w64; file names are UTF-8 and may be longer than 260 characters), macOS, Arm with
               NEON, WebAssembly with or without -msimd128. The compiler of Visual Studio gets the scalar kernels, clang-cl
               those for AVX2 and AVX-512. Training with the scalar kernels gives the same bits on all of them, with any
               compiler flags that keep IEEE 754 (not -ffast-math), as long as the rounding mode is the default, to nearest:
               a host that changes it sets it back around calls.
   THREADS     One thread at a time per context. Work is split through the parallel hook on a grid of chunks that depends
               on sizes only, so results do not depend on the number of workers.
   NAMES       Functions are gsf_VERB_NOUN, in the modules gsf_traj_VERB_NOUN, gsf_splat_VERB_NOUN and gsf_nn_VERB_NOUN;
               without a noun the object is the module's own (gsf_splat_load loads splats). One verb per idea in all
               modules; tests/api.py checks every public name against this table:
       init                 fill in the caller's struct; it owns nothing, so there is no destroy
       make destroy         create an object that owns memory, from a desc or from data; free it
       load save            read an object from a file or folder; write it to one
       parse format         read an object from bytes in memory; append its bytes to a gsf_buffer
       read write           a whole file as bytes
       append               add to a gsf_buffer
       encode decode        turn pixels and text into PNG, tokens, features or latents, and back
       query                report sizes, costs or a plan without doing the work, in an ..._info struct or as numbers
       resolve              fill in every default of a desc
       get set copy         borrow, replace or duplicate one property of an object
       find count           look something up (NULL, 0 or an error if there is none); return how many there are
       check                validate; the error says what is wrong
       wrap                 make a view of the caller's memory
       convert resize project split sort filter quantize    turn data into other data
       step                 advance a trainer, fixer or sampler, which the host drives, by one step
       render restore sample caption run    compute a result with splats, a restorer, a path or a model
       measure              compute a metric or statistic
       draw                 draw a random number
       look                 make a pose that looks at a point
       describe             return the text of an enumerator
       alloc free fail log request clear is    memory, errors and cancellation, through the context
               Internal names begin with gsf__ or GSF__ and are never exported. Types are gsf_NOUN, gsf_traj_NOUN and
               gsf_nn_NOUN: a ..._desc holds a call's options, with zero as the default; ..._stats reports what a call did;
               ..._info is the result of a query. Enumerators begin with their type's name (GSF_LOG_ERROR of
               gsf_log_level), except for dtypes (GSF_U8). Flags are int32_t, counts of elements in memory size_t, sizes of
               tensors and images int64_t. Bytes are passed as (data, size) with a name for error messages; output of
               unknown size goes to a gsf_buffer. Terms: means, log_scales, quats, opacity_logits, sh; w2c, c2w; q, k, v;
               tokens, positions, latents.
   WHERE TO ADD
       a restorer       gsf_restorer under "restorer interface": struct_size, the four functions from query_fn to
                        end_fn and, if there is something to release, destroy_fn. query_fn runs before begin_fn, and
                        for every clip of gsf_restore_clip, so it changes nothing; begin_fn and end_fn run once per
                        round. restore_fn writes every pixel of out_color and out_confidence, which are undefined
                        before. If query_fn sets needs_carried, restore_fn may ask window->carry_fn (unless NULL, or
                        beyond struct_size) for the photos as they appear in a frame. gsf_splat_make_warp in
                        gsfixer_splat.h is an example
       a kernel         over the vocabulary of >>lanes, written once and compiled per instruction set
       an image format  gsf__image_kind_of in >>images
   SECTIONS    >>glm >>internals >>maths >>lanes >>context >>memory >>parallel >>random >>text >>files >>chunks >>json >>deflate
               >>images >>resize >>metrics >>cameras >>clips >>oiio
*/
#ifndef GSF_BASE_INCLUDED
#define GSF_BASE_INCLUDED

#include <stddef.h>
#include <stdint.h>

#define GSF_VERSION "0.2.0"

#ifndef GSF_API
#if defined(GSFIXER_STATIC) && (defined(__GNUC__) || defined(__clang__))
#define GSF_API static __attribute__((unused)) // a file may call only some of them
#elif defined(GSFIXER_STATIC)
#define GSF_API static
#else
#define GSF_API extern
#endif
#endif

#if defined(__MINGW32__) && defined(__GNUC__) && !defined(__clang__)
#define GSF__PRINTF_KIND gnu_printf // the text functions use MinGW's own printf, not that of the C runtime, which has no %zu
#else
#define GSF__PRINTF_KIND printf
#endif
#if defined(__GNUC__) || defined(__clang__)
#define GSF_NODISCARD __attribute__((warn_unused_result))
#define GSF_RESTRICT __restrict__
#define GSF_PRINTF(fmt, args) __attribute__((format(GSF__PRINTF_KIND, fmt, args)))
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
    X(GSF_ERROR_RESTORER, "the restorer failed")                           \
    X(GSF_ERROR_NOT_FOUND, "no such file")

typedef enum gsf_result {
#define GSF_X(name, text) name,
    GSF_RESULTS(GSF_X)
#undef GSF_X
} gsf_result;

// English text of a result, never NULL.
GSF_API const char* gsf_describe_result(gsf_result result);

// ---- context -------------------------------------------------------------------

typedef struct gsf_context gsf_context;

typedef enum gsf_cpu_level { // instruction sets that kernels may use; AUTO selects the fastest one of the machine
    GSF_CPU_AUTO = 0,
    GSF_CPU_SCALAR = 1,
    GSF_CPU_AVX2 = 2,        // with FMA and F16C
    GSF_CPU_AVX512 = 3,      // F, BW, DQ and VL
    GSF_CPU_AVX512_VNNI = 4, // AVX512 and 8-bit dot products
    GSF_CPU_AVX512_BF16 = 5, // AVX512_VNNI and bfloat16 dot products; not by AUTO where these are slower than float32
    GSF_CPU_AMX = 6,         // AVX512_BF16 and products of tiles, bfloat16 and 8-bit; gsf_init_context asks Linux to save them
    GSF_CPU_SIMD128 = 7,     // four lanes: NEON of 64-bit Arm, SIMD128 of WebAssembly (which is chosen when compiling)
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

// One unit of parallel work. `worker` is less than the hook's worker_count; two chunks that run at the same time never have
// the same worker.
typedef void (*gsf_chunk_fn)(void* arg, size_t chunk, int32_t worker);

typedef struct gsf_parallel { // run body for chunks 0..chunk_count-1, return when all are done; never nested
    void (*for_fn)(void* user, size_t chunk_count, gsf_chunk_fn body, void* arg);
    int32_t worker_count;
    void* user;
} gsf_parallel;

typedef struct gsf_io { // both or neither (neither: stdio; files are written under a temporary name and renamed)
    // Reads a whole file. *data comes from ctx->allocator via gsf_alloc and is freed by the library. Return
    // GSF_ERROR_NOT_FOUND if the file does not exist, and only then: optional files (a photo, one of two formats) may be
    // missing, while any other error ends the call.
    gsf_result (*read_fn)(void* user, gsf_context* ctx, const char* path, void** data, size_t* size);
    gsf_result (*write_fn)(void* user, gsf_context* ctx, const char* path, const void* data, size_t size);
    void* user;
    int32_t plain_files; // 1: read_fn reads ordinary files of the platform (and only logs or counts reads, for example);
                         // the library may then also list folders, map files and read parts of them, as with stdio
} gsf_io;

typedef struct gsf_progress { // called on the calling thread, at most a few times per second of work
    void (*progress_fn)(void* user, const char* stage, double done, double total);
    void* user;
} gsf_progress;

struct gsf_context {
    gsf_allocator allocator;
    gsf_logger logger;
    gsf_parallel parallel;   // zero: OpenMP if compiled with it, else serial
    gsf_io io;
    gsf_progress progress;
    gsf_cpu_level cpu_level; // in: AUTO or a level to force; out: the level in use
    int32_t threads;         // for the OpenMP default: number of workers, 0 = all cores
    int32_t cancel;          // see gsf_request_cancel
    int32_t initialized;
    const struct gsf__services* services; // private: internals of this header for the other modules' implementations
    char error[512];         // message of the last error
};

// Fills in every hook that is zero and resolves cpu_level (a level that the machine does not support is lowered).
// Call once on a zeroed or filled-in struct. A context owns nothing, so there is no destroy function.
GSF_API GSF_NODISCARD gsf_result gsf_init_context(gsf_context* ctx);

// Requests that running work stop at its next safe point with GSF_ERROR_CANCELLED. Safe to call from signal handlers and
// other threads. Reset by gsf_clear_cancel.
GSF_API void gsf_request_cancel(gsf_context* ctx);
GSF_API void gsf_clear_cancel(gsf_context* ctx);
GSF_API int32_t gsf_is_cancelled(const gsf_context* ctx);

// Name of an instruction set level ("scalar", "avx2", "avx512", "avx512_vnni", "avx512_bf16", "amx",
// "simd128").
GSF_API const char* gsf_describe_cpu_level(gsf_cpu_level level);

// Sets ctx->error (printf style), logs it and returns `result`. For hooks and restorers written by the host as well.
// The message is one line: control characters, for example in text quoted from a file, become '?'.
GSF_API gsf_result gsf_fail(gsf_context* ctx, gsf_result result, const char* format, ...) GSF_PRINTF(3, 4);
GSF_API void gsf_log(gsf_context* ctx, gsf_log_level level, const char* format, ...) GSF_PRINTF(3, 4);

// Memory from the context's allocator, 64-byte aligned. count*size is checked. NULL (and ctx->error) on failure.
GSF_API void* gsf_alloc(gsf_context* ctx, size_t count, size_t size);
GSF_API void* gsf_alloc_zeroed(gsf_context* ctx, size_t count, size_t size);
GSF_API void gsf_free(gsf_context* ctx, void* memory); // NULL is fine

// ---- random numbers ------------------------------------------------------------
// Counter-based: pure functions of (seed, stream, index), so results do not depend on threads, skipped draws or resuming.

GSF_API uint64_t gsf_draw_bits(uint64_t seed, uint64_t stream, uint64_t index);
GSF_API double gsf_draw_uniform(uint64_t seed, uint64_t stream, uint64_t index); // [0,1)
GSF_API double gsf_draw_normal(uint64_t seed, uint64_t stream, uint64_t index);    // mean 0, variance 1

// ---- text and files ------------------------------------------------------------

typedef struct gsf_buffer { // growing bytes or UTF-8 text, zero-terminated as soon as anything has been appended
    char* data;
    size_t size, capacity;
    int32_t failed; // an allocation failed; later calls do nothing
} gsf_buffer;

// Append printf-style text, raw bytes or JSON values. Running out of memory sets out->failed; check it once at the end.
GSF_API void gsf_append_text(gsf_context* ctx, gsf_buffer* out, const char* format, ...) GSF_PRINTF(3, 4);
GSF_API void gsf_append_bytes(gsf_context* ctx, gsf_buffer* out, const char* data, size_t size);
GSF_API void gsf_append_json_string(gsf_context* ctx, gsf_buffer* out, const char* string); // quoted and escaped
GSF_API void gsf_append_json_number(gsf_context* ctx, gsf_buffer* out, double value);       // NaN, inf become null
GSF_API void gsf_destroy_buffer(gsf_context* ctx, gsf_buffer* buffer);

// Whole-file input and output through the io hook. `*data` is freed with gsf_free. Only regular files are read: pipes and
// devices are refused instead of blocking.
// gsf_write_file replaces the file only after everything is written: on a full disk, the previous file survives.
GSF_API GSF_NODISCARD gsf_result gsf_read_file(gsf_context* ctx, const char* path, void** data, size_t* size);
GSF_API GSF_NODISCARD gsf_result gsf_write_file(gsf_context* ctx, const char* path, const void* data, size_t size);

/* Tagged chunks, the container of checkpoints. Little-endian:
       char magic[8] "GSFCHUNK" | u32 version
       repeated: char tag[4] | u64 size | bytes[size] | u32 crc32(tag, size, bytes)
       the last chunk is "END " of size 0, so that truncation is detected. */
typedef struct gsf_chunk {
    char tag[5]; // zero-terminated
    const void* data; // points into the file's buffer; any alignment
    size_t size;
} gsf_chunk;

// Adds a chunk to `out` (which starts as a zeroed gsf_buffer). Finish with gsf_append_last_chunk, then gsf_write_file.
GSF_API void gsf_append_chunk(gsf_context* ctx, gsf_buffer* out, const char* tag, const void* data, size_t size);
GSF_API void gsf_append_last_chunk(gsf_context* ctx, gsf_buffer* out);
// Checks a whole file (magic, sizes, checksums, end). `name` is used in error texts.
GSF_API GSF_NODISCARD gsf_result gsf_check_chunks(gsf_context* ctx, const char* name, const void* data, size_t size);
// Finds a chunk in checked data; returns 0 when there is none.
GSF_API int32_t gsf_find_chunk(const void* data, size_t size, const char* tag, gsf_chunk* out);

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
    uint32_t offset;     // byte offset in the source, for error messages
    const char* key;     // decoded, zero-terminated; NULL outside objects
    const char* string;  // decoded, zero-terminated; strings only
    size_t string_size;
    double number;
} gsf_json_value;

typedef struct gsf_json { // a parsed document; values[0] is the root
    gsf_json_value* values;
    size_t count;
    char* strings;
    char name[128]; // for error messages
} gsf_json;

// RFC 8259, strictly: UTF-8 checked, duplicate keys refused, at most 64 levels deep, finite numbers.
// Memory use is proportional to the size of the text.
GSF_API GSF_NODISCARD gsf_result gsf_parse_json(gsf_context* ctx, const char* name, const char* text, size_t size,
                                                gsf_json* out);
GSF_API void gsf_destroy_json(gsf_context* ctx, gsf_json* json);
// Member of an object; NULL if there is none, or if `object` is NULL or not an object.
GSF_API const gsf_json_value* gsf_find_json_member(const gsf_json* json, const gsf_json_value* object, const char* key);
// Element of an array or NULL. Linear in index; walk `child` and `next` for long arrays.
GSF_API const gsf_json_value* gsf_find_json_element(const gsf_json* json, const gsf_json_value* array, size_t index);

// ---- images --------------------------------------------------------------------

typedef enum gsf_dtype { GSF_U8 = 0, GSF_U16, GSF_F16, GSF_F32, GSF_F64 } gsf_dtype;
// A label: pixels are converted only where a function's comment says so. sRGB is IEC 61966-2-1, extended above 1.
typedef enum gsf_color_space { GSF_COLOR_SRGB = 0, GSF_COLOR_LINEAR } gsf_color_space;

// A view of pixels. Strides are in bytes, so packed, padded, planar and flipped images are all just views.
// `owned` is non-NULL only in images made by this library; gsf_destroy_image frees it.
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

// Copies pixels between dtypes, layouts and color spaces (where the labels differ, alpha, the last of 2 or 4 channels, is
// kept). u8 to float divides by 255; float to u8 is clamp(x*255 + 0.5) truncated (torchvision save_image); NaN becomes 0.
// 1 channel is replicated to 3; 4 to 3 drops alpha; other counts are an error. src and dst may be the same pixels.
GSF_API GSF_NODISCARD gsf_result gsf_convert_image(gsf_context* ctx, const gsf_image* src, const gsf_image* dst);

// Reads PNG, JPEG, BMP, TGA, PNM (stb) and, with GSF_USE_OIIO, whatever OpenImageIO reads. channels: 1, 3, 4 or
// 0 = as in the file. Result is u8 (stb), or the dtype of the file (OpenImageIO: what stb cannot read, and 16 bits).
// A file that claims more pixels than its size can hold is refused before it is decoded. EXIF rotation is not applied.
// Scratch memory of stb and OpenImageIO does not come from the context; the returned pixels do.
GSF_API GSF_NODISCARD gsf_result gsf_load_image(gsf_context* ctx, const char* path, int32_t channels, gsf_image* out);
GSF_API GSF_NODISCARD gsf_result gsf_decode_image(gsf_context* ctx, const char* name, const void* data,
                                                  size_t size, int32_t channels, gsf_image* out);
// Reads only the header.
GSF_API GSF_NODISCARD gsf_result gsf_query_image(gsf_context* ctx, const char* path, int64_t* width, int64_t* height,
                                                 int32_t* channels);
// Writes by extension: .png (u16 as 16 bits, else u8; in sRGB, from any color space), .jpg (u8 in sRGB, quality 95), .exr (f16
// or else f32, linear; uncompressed without GSF_USE_OIIO) and, with GSF_USE_OIIO, .tif (dtype kept, f16 as f32).
GSF_API GSF_NODISCARD gsf_result gsf_save_image(gsf_context* ctx, const char* path, const gsf_image* image);
// The file in memory (reports embed them). `extension` is ".png", ".jpg" or ".exr".
GSF_API GSF_NODISCARD gsf_result gsf_encode_image(gsf_context* ctx, const gsf_image* image, const char* extension,
                                                  gsf_buffer* out);

typedef enum gsf_resize_filter {
    GSF_RESIZE_PIL_BILINEAR,   // PIL.Image.resize: antialiased when shrinking, u8 in two integer passes, bit-exact
    GSF_RESIZE_PIL_BICUBIC,    //   (a = -0.5)
    GSF_RESIZE_PIL_LANCZOS,    //   (a = 3)
} gsf_resize_filter;

// Resizes src to the size of dst. The views must not overlap and have the same channel count and dtype, u8 or f32. Channels
// are resized independently, while PIL premultiplies RGBA by alpha.
GSF_API GSF_NODISCARD gsf_result gsf_resize_image(gsf_context* ctx, const gsf_image* src, gsf_resize_filter filter,
                                                  const gsf_image* dst);

// ---- pixel metrics -------------------------------------------------------------

typedef enum gsf_metric {
    GSF_METRIC_PSNR,              // 10 log10(1/mse); +infinity for identical images
    GSF_METRIC_DIFFERENCE,        // mean absolute difference. VBench's temporal flickering of a clip is 1 less its mean over
                                  // pairs of successive frames
    GSF_METRIC_SSIM_3DGS,         // 11x11 Gaussian sigma 1.5, zero padding, variances not clamped: the 3DGS papers' figure
    GSF_METRIC_SSIM_TORCHMETRICS, // the same kernel, reflect padding, variances clamped at 0 (gsplat's trainer)
    GSF_METRIC_SSIM_SKIMAGE,      // scikit-image's default: 7x7 uniform window, sample covariance, mean over the interior
    GSF_METRIC_MS_SSIM,           // MS-SSIM (Wang et al. 2003) over five scales, as pytorch-msssim computes it: per channel,
                                  // means over the interior; halving an odd side pads it with a line of zeros in front
    GSF_METRIC_MS_SSIM_TORCHMETRICS, // as torchmetrics does: over all channels together, the last scale with the reflected
                                  // border, variances clamped at 0; halving an odd side drops its last line
} gsf_metric;

// Both images must have the same size and channel count; dtypes may differ (floats in [0,1], integers are scaled to
// value / maximum). All sums are in double and in a fixed order. A NaN or infinity in a counted pixel gives
// GSF_ERROR_NUMERIC.
// mask: NULL, or u8 one-channel of the same size; only pixels with mask != 0 count (for SSIM: mean of the SSIM map over
// them; MS-SSIM takes no mask). If the mask excludes all pixels, or the image is smaller than the windows need (sides of 6
// pixels for SSIM_TORCHMETRICS, 7 for SSIM_SKIMAGE, 161 for MS_SSIM, 176 for MS_SSIM_TORCHMETRICS), the result is
// GSF_ERROR_DEGENERATE.
GSF_API GSF_NODISCARD gsf_result gsf_measure_image(gsf_context* ctx, gsf_metric metric, const gsf_image* a, const gsf_image* b,
                                                   const gsf_image* mask, double* out);

// ---- cameras -------------------------------------------------------------------

typedef struct gsf_camera { // pinhole: u = fx X/Z + cx, v = fy Y/Z + cy with (X,Y,Z) = w2c (x,y,z,1)
    double w2c[16];         // column-major rigid transform
    double fx, fy, cx, cy;  // pixels
    int32_t width, height;
} gsf_camera;

// Checks that a camera is finite and rigid (to 1e-4) with positive focal lengths and size; otherwise the error names the
// entry.
GSF_API GSF_NODISCARD gsf_result gsf_check_camera(gsf_context* ctx, const gsf_camera* camera);
GSF_API void gsf_get_camera_center(const gsf_camera* camera, double center[3]);
GSF_API void gsf_get_camera_c2w(const gsf_camera* camera, double c2w[16]);
GSF_API void gsf_set_camera_c2w(gsf_camera* camera, const double c2w[16]); // inverts a rigid transform
// World point to pixel and camera depth. Returns 0 (u, v unchanged) if depth <= 0.
GSF_API int32_t gsf_project_point(const gsf_camera* camera, const double point[3], double* u, double* v, double* depth);
// The same view at another image size; intrinsics are scaled separately in width and height.
GSF_API gsf_camera gsf_resize_camera(const gsf_camera* camera, int32_t width, int32_t height);

// By the name of the file: transforms.json (nerfstudio; photos are images/NAME), images.txt (COLMAP text, with cameras.txt and
// an empty points3D.txt beside it), or else, with any name, a JSON list of cameras
// ({"cameras":[{"name","w2c":[16 numbers, row-major],"fx","fy","cx","cy","width","height"}]}),
// the format of `gsfix path`, `gsfix render --path` and a restorer job's cameras.json. Names may be NULL; in the first two
// formats they are then 00000.png, 00001.png ...
GSF_API GSF_NODISCARD gsf_result gsf_save_cameras(gsf_context* ctx, const char* path, const gsf_camera* cameras,
                                                  const char* const* names, size_t count);
// *cameras is freed with gsf_free.
GSF_API GSF_NODISCARD gsf_result gsf_load_cameras(gsf_context* ctx, const char* path, gsf_camera** cameras,
                                                  size_t* count);

// ---- restorer interface --------------------------------------------------------
// A restorer turns renders with artifacts into clean frames. The repair loop of gsfixer_splat.h uses only this struct; a
// host fills in its own functions or uses one of the toolkit's restorers (warp in gsfixer_splat.h, the video model in
// gsfixer_nn.h).

typedef struct gsf_restorer_info { // what a restorer accepts; zero = any
    uint32_t struct_size;           // set by the caller, which zeroes the rest; nothing is written beyond it
    int32_t frame_count_min, frame_count_max;
    int32_t frame_count_step;       // legal counts: min, min + step, ... up to max
    int32_t width_multiple, height_multiple;
    int32_t width_max, height_max;
    int32_t needs_depth, needs_alpha, needs_caption;
    int32_t frame_count, width, height; // preferred values, used by default; 0: no preference
    int32_t squash;                 // frames contain the full image scaled to `width` x `height` (or another legal
                                    // size), each axis separately; otherwise pixels stay square
    int32_t explains;               // its output shows what the references explain, with confidence 0 where they explain
                                    // nothing: the loop compares it with the renders to find windows that need no
                                    // repair, instead of reprojecting the references itself
    double bytes, flops;            // estimate for one window of the queried size; 0 = unknown
    // A restorer sets what follows only if struct_size covers it.
    int32_t needs_carried;          // references per frame that it asks for with carry_fn; 0 = none
    float lambda;                   // preferred weight of its frames in training, used by default; 0: no preference
    int32_t lambda_views;           // photos for which that weight is meant; the default falls with more of them, as
                                    // lambda_views / photos. 0: the same for any number
    float frame_scale;              // preferred sides of the frames to train on, as a share of the photos', used by default
                                    // unless `squash` is set; 0: as large as the photos
    float warp_weight;              // preferred weight of the frames of `warp` (gsfixer_splat.h) that the loop mixes with
                                    // its own, which have 1, used by default; 0: none
} gsf_restorer_info;

typedef struct gsf_reference { // a photo the scene was trained on
    gsf_image color;  // f32, 3 channels; masked pixels are replaced by the splats' render and have no depth
    gsf_image render; // f32, 3 channels: the splats rendered from this camera; data NULL unless needs_depth
    gsf_image depth;  // f32 camera depth rendered from the splats, 0 = none; data NULL unless needs_depth
    gsf_camera camera;
} gsf_reference;

// What one reference shows in a frame: f32 images of the frame's size. The photo is carried there through the
// reference's own depth, which is that of stereo between the photos or, where stereo is silent, that of the splats. The
// score says how well it is verified: 1 = the photos agree on it, from 0.5 on at least one other photo confirms depth
// and colour, below that nothing but the splats vouches for the depth; 0 = the reference shows nothing here (the other
// images are then 0, too). Where surfaces of the reference cover each other the nearest one counts, but one that only
// another reference shows covers nothing: compare the depths. Colours are of one exposure per frame, like the photos
// around it. The last two images do not depend on the reference's depth being right: they look up the photo where the
// frame's own depth puts the pixel.
typedef struct gsf_carried {
    int32_t reference;    // index into the references; -1, with images that are 0, if there are fewer
    gsf_image color;      // 3 channels: the photo
    gsf_image residual;   // 3 channels: photo - render at the photo's camera, in the photo's own exposure
    gsf_image score;      // 1 channel, [0,1]
    gsf_image depth;      // 1 channel: camera depth in the frame of what the reference shows
    gsf_image angle;      // 1 channel: radians, at that point, between the rays to the frame and to the reference
    gsf_image back_color; // 3 channels: the photo at the point that the frame shows
    gsf_image back_ratio; // 1 channel: that point's depth in the reference / the reference's own depth there; 0 = outside
                          // the photo, or no depth there or in the frame. Above 1 = hidden from the reference
} gsf_carried;

typedef struct gsf_restore_window { // one clip; all pointers are borrowed for the call
    uint32_t struct_size;
    int32_t frame_count;
    const gsf_image* color;           // f32, 3 channels, [0,1]; all of the same size
    const gsf_image* depth;           // f32, 1 channel: expected camera depth, 0 = none; NULL unless needs_depth
    const gsf_image* alpha;           // f32, 1 channel: 1 - transmittance; NULL unless needs_alpha
    const gsf_camera* cameras;
    const int32_t* reference_index;   // per frame: the reference with the same pose, or -1
    const char* caption;              // NULL = none
    uint64_t seed;
    gsf_image* out_color;             // f32, 3 channels, same size; written by the restorer
    gsf_image* out_confidence;        // f32, 1 channel, [0,1]; weight of each restored pixel in training
    int32_t clip;                     // index of the clip in its run, from 0; continues across the loop's rounds
    int32_t part;                     // index of the part if a clip is restored in several parts, from 0
    // What the slot-th nearest reference (from 0) shows in a frame of the window; *out is borrowed until the next call. NULL
    // unless needs_carried, and if the host cannot tell. Frames are carried when they are asked for, so ask once.
    gsf_result (*carry_fn)(void* carry_user, gsf_context* ctx, int32_t frame, int32_t slot, gsf_carried* out);
    void* carry_user;
} gsf_restore_window;                 // struct_size may end before carry_fn, which is then not there

// One restorer serves one loop at a time: its state belongs to one run, from begin_fn to end_fn.
typedef struct gsf_restorer {
    uint32_t struct_size; // sizeof(gsf_restorer) of the caller, so that fields can be added
    const char* name;
    void* user;
    gsf_result (*query_fn)(void* user, gsf_context* ctx, int32_t frame_count, int32_t width, int32_t height,
                           gsf_restorer_info* out);
    // References are borrowed for the call; copy what later windows need. The toolkit's restorers refuse a second begin
    // before end.
    gsf_result (*begin_fn)(void* user, gsf_context* ctx, const gsf_reference* references, int32_t reference_count);
    gsf_result (*restore_fn)(void* user, gsf_context* ctx, const gsf_restore_window* window);
    void (*end_fn)(void* user, gsf_context* ctx); // releases what begin allocated; called once per successful begin
    void (*destroy_fn)(void* user, gsf_context* ctx); // releases user, for gsf_destroy_restorer only; NULL: nothing to release
} gsf_restorer;                                       // struct_size may end before destroy_fn, which is then not there

// Destroys a restorer, of the toolkit or of a host, and clears it. NULL and a cleared restorer are ignored.
GSF_API void gsf_destroy_restorer(gsf_context* ctx, gsf_restorer* restorer);

/* Restores a clip of any size and length. Call between begin_fn and end_fn. restore_fn gets only sizes and lengths that
   its limits allow; out_color and out_confidence receive the caller's frames at the caller's size.
       size    Frames are resized to the restorer's preferred size (limits.squash) or the nearest legal one, and back,
               each axis separately, with PIL's bicubic filter (depth: nearest neighbour). If pixels must stay square and all
               legal sizes have a different aspect ratio, the result is GSF_ERROR_UNSUPPORTED.
       length  A clip that is too short or between two legal lengths is stretched to the next legal length, by nearest
               frame in time in both directions. A clip that is too long is restored in evenly spaced parts of the preferred
               length, which overlap by at least a sixth of their frames and are cross-faded there. Part p gets the seed
               window->seed + p; window->clip is the same for all parts.
   Clips that need neither are passed through unchanged. (The GSFixer release does not support other lengths: its
   benchmark subsamples clips to 49 frames and skips shorter ones, so the remaining frames are not restored.) */
GSF_API GSF_NODISCARD gsf_result gsf_restore_clip(gsf_context* ctx, const gsf_restorer* restorer,
                                                  const gsf_restore_window* window);

#ifdef __cplusplus
}
#endif

// ---- >>glm ---------------------------------------------------------------------

#if defined(GSF_USE_GLM) && defined(__cplusplus)
#include <glm/mat4x4.hpp>
#include <glm/vec3.hpp>
#include <cstring>

// Matrices already have glm's layout (column-major doubles), so these functions only copy.
inline glm::dmat4 gsf_to_glm(const double m[16]) {
    glm::dmat4 out;
    std::memcpy(&out[0][0], m, sizeof out);
    return out;
}
inline void gsf_from_glm(const glm::dmat4& m, double out[16]) { std::memcpy(out, &m[0][0], sizeof m); }

// World to camera in this toolkit's axes (x right, y down, z forward).
inline glm::dmat4 gsf_to_glm_w2c(const gsf_camera& camera) { return gsf_to_glm(camera.w2c); }

// World to camera in OpenGL's axes (x right, y up, z backward), what glm::lookAt returns.
inline glm::dmat4 gsf_to_glm_view(const gsf_camera& camera) {
    glm::dmat4 flip(1.0);
    flip[1][1] = flip[2][2] = -1.0;
    return flip * gsf_to_glm(camera.w2c);
}
// The inverse of that: sets w2c from an OpenGL view matrix (rigid).
inline void gsf_from_glm_view(const glm::dmat4& view, gsf_camera* camera) {
    glm::dmat4 flip(1.0);
    flip[1][1] = flip[2][2] = -1.0;
    gsf_from_glm(flip * view, camera->w2c);
}

// OpenGL projection (clip z in [-1,1], for use after gsf_to_glm_view): with the viewport (0, 0, width, height) a point
// lands on pixel (u, height - v), since OpenGL counts rows from the bottom.
inline glm::dmat4 gsf_to_glm_projection(const gsf_camera& camera, double near_plane, double far_plane) {
    glm::dmat4 p(0.0);
    p[0][0] = 2.0 * camera.fx / camera.width;
    p[1][1] = 2.0 * camera.fy / camera.height;
    p[2][0] = 1.0 - 2.0 * camera.cx / camera.width;
    p[2][1] = 2.0 * camera.cy / camera.height - 1.0;
    p[2][2] = -(far_plane + near_plane) / (far_plane - near_plane);
    p[2][3] = -1.0;
    p[3][2] = -2.0 * far_plane * near_plane / (far_plane - near_plane);
    return p;
}
// Sets the intrinsics of a camera of a given size from such a projection.
inline void gsf_from_glm_projection(const glm::dmat4& p, int32_t width, int32_t height, gsf_camera* camera) {
    camera->width = width;
    camera->height = height;
    camera->fx = 0.5 * p[0][0] * width;
    camera->fy = 0.5 * p[1][1] * height;
    camera->cx = 0.5 * (1.0 - p[2][0]) * width;
    camera->cy = 0.5 * (1.0 + p[2][1]) * height;
}
#endif // GSF_USE_GLM

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
#include <time.h>
#if defined(_WIN32)
#ifndef WIN32_LEAN_AND_MEAN
#define WIN32_LEAN_AND_MEAN
#endif
#ifndef NOMINMAX
#define NOMINMAX
#endif
#include <windows.h>
#include <fcntl.h>
#include <io.h>
#elif defined(__unix__) || defined(__APPLE__)
#include <sys/stat.h>
#endif

#ifndef GSF_ASSERT
#include <assert.h>
#define GSF_ASSERT(x) assert(x)
#endif

// Unoptimised, a function would keep the temporaries of all that is inlined into it: hundreds of KB of stack.
#if defined(__OPTIMIZE__) && (defined(__GNUC__) || defined(__clang__))
#define GSF__ALWAYS_INLINE __attribute__((always_inline))
#else
#define GSF__ALWAYS_INLINE
#endif

// Kernels use target attributes and operators on vectors, which GCC and Clang (also as clang-cl) have; the compiler of
// Visual Studio, which has neither in C, gets the scalar ones.
#if !defined(GSF_NO_SIMD) && (defined(__x86_64__) || defined(_M_X64)) && \
    ((defined(__GNUC__) && !defined(__TINYC__)) || defined(__clang__))
#define GSF__X86 1
#include <immintrin.h>
#if defined(_MSC_VER)
#include <intrin.h>
#else
#include <cpuid.h>
#endif
#if defined(__MINGW32__) && !defined(__clang__)
// The stack is aligned to 16 bytes only on Windows, and GCC does not align its own spills of wider registers there (GCC bug
// 54412), so its aligned moves are assembled as unaligned ones, which are as fast.
__asm__(".ifndef gsf.unaligned\n.set gsf.unaligned, 1\n"
        ".macro vmovaps args:vararg\nvmovups \\args\n.endm\n.macro vmovapd args:vararg\nvmovupd \\args\n.endm\n"
        ".macro vmovdqa args:vararg\nvmovdqu \\args\n.endm\n.macro vmovdqa32 args:vararg\nvmovdqu32 \\args\n.endm\n"
        ".macro vmovdqa64 args:vararg\nvmovdqu64 \\args\n.endm\n.endif");
#endif
#define GSF__TARGET_AVX2 __attribute__((target("avx2,fma,f16c,bmi")))
#define GSF__INLINE_AVX2 GSF__TARGET_AVX2 GSF__ALWAYS_INLINE static inline
#define GSF__AVX512 "avx2,fma,f16c,bmi,avx512f,avx512bw,avx512dq,avx512vl"
#define GSF__TARGET_AVX512 __attribute__((target(GSF__AVX512)))
#define GSF__INLINE_AVX512 GSF__TARGET_AVX512 GSF__ALWAYS_INLINE static inline
#define GSF__TARGET_VNNI __attribute__((target(GSF__AVX512 ",avx512vnni")))
#define GSF__INLINE_VNNI GSF__TARGET_VNNI GSF__ALWAYS_INLINE static inline
#define GSF__TARGET_BF16 __attribute__((target(GSF__AVX512 ",avx512bf16")))
#define GSF__INLINE_BF16 GSF__TARGET_BF16 GSF__ALWAYS_INLINE static inline
#if defined(__linux__) && defined(__x86_64__) && !defined(__ILP32__) && \
    ((defined(__clang__) && __clang_major__ >= 12) || (!defined(__clang__) && __GNUC__ >= 11))
#define GSF__AMX 1
#define GSF__TARGET_AMX __attribute__((target(GSF__AVX512 ",avx512bf16,amx-tile,amx-bf16,amx-int8")))
#define GSF__INLINE_AMX GSF__TARGET_AMX GSF__ALWAYS_INLINE static inline
#else
#define GSF__AMX 0
#endif
#ifdef GSF_NO_AVX512 // nothing refers to the kernels, so that compilers drop them
#define GSF__REACHES(level, wanted) 0
#else
#define GSF__REACHES(level, wanted) ((level) >= GSF_CPU_##wanted) // for AVX512, AVX512_VNNI, AVX512_BF16, AMX
#endif
#else
#define GSF__X86 0
#define GSF__AMX 0
#endif

// Four lanes: NEON of 64-bit Arm, which always has it, or SIMD128 of WebAssembly (-msimd128).
#if !defined(GSF_NO_SIMD) && defined(__aarch64__) && (defined(__GNUC__) || defined(__clang__))
#define GSF__SIMD128 1
#define GSF__NEON 1
#include <arm_neon.h>
#elif !defined(GSF_NO_SIMD) && defined(__wasm_simd128__)
#define GSF__SIMD128 1
#define GSF__NEON 0
#include <wasm_simd128.h>
#else
#define GSF__SIMD128 0
#define GSF__NEON 0
#endif

#ifdef _OPENMP
#include <omp.h>
#endif

// Every implementation is enclosed in these two. In between, the compiler must not contract a * b + c into an FMA, so that
// C11 and C++17 builds give the same bits with all compilers; the code that follows gets the compiler's mode back.
#if defined(__clang__)
#define GSF__BEGIN_IMPLEMENTATION _Pragma("STDC FP_CONTRACT OFF")
#define GSF__END_IMPLEMENTATION _Pragma("STDC FP_CONTRACT DEFAULT")
#elif defined(__GNUC__)
// g++ before 13 takes the operands that its AVX-512 intrinsics leave undefined for uninitialised variables (GCC bug 105593).
#if defined(__MINGW32__) // isfinite and isnan are macros that convert to float; rpcndr.h has a type named byte
#define GSF__BEGIN_QUIET                                                                                \
    _Pragma("GCC diagnostic push") _Pragma("GCC diagnostic ignored \"-Wfloat-conversion\"")             \
        _Pragma("GCC diagnostic ignored \"-Wshadow\"") _Pragma("GCC diagnostic ignored \"-Wuninitialized\"") \
            _Pragma("GCC diagnostic ignored \"-Wmaybe-uninitialized\"")
#define GSF__END_QUIET _Pragma("GCC diagnostic pop")
#elif defined(__cplusplus) && __GNUC__ < 13
#define GSF__BEGIN_QUIET                                                                        \
    _Pragma("GCC diagnostic push") _Pragma("GCC diagnostic ignored \"-Wuninitialized\"")        \
        _Pragma("GCC diagnostic ignored \"-Wmaybe-uninitialized\"")
#define GSF__END_QUIET _Pragma("GCC diagnostic pop")
#else
#define GSF__BEGIN_QUIET
#define GSF__END_QUIET
#endif
#define GSF__BEGIN_IMPLEMENTATION \
    GSF__BEGIN_QUIET _Pragma("GCC push_options") _Pragma("GCC optimize(\"fp-contract=off\")")
#define GSF__END_IMPLEMENTATION _Pragma("GCC pop_options") GSF__END_QUIET
#else
#define GSF__BEGIN_IMPLEMENTATION
#define GSF__END_IMPLEMENTATION
#endif

#if defined(__GNUC__) || defined(__clang__)
#define GSF__SHARED static __attribute__((unused)) // a translation unit may use only some of them
#define GSF__NOINLINE __attribute__((noinline))
#define GSF__ATOMIC_LOAD(p) __atomic_load_n((p), __ATOMIC_RELAXED)
#define GSF__ATOMIC_STORE(p, v) __atomic_store_n((p), (v), __ATOMIC_RELAXED)
#else
#define GSF__SHARED static
#define GSF__NOINLINE
#define GSF__ATOMIC_LOAD(p) (*(volatile const int*)(p))
#define GSF__ATOMIC_STORE(p, v) (*(volatile int*)(p) = (v))
#endif

#define GSF__TRY(call)                                         \
    do {                                                       \
        const gsf_result gsf__try_result = (call);             \
        if (gsf__try_result != GSF_OK) return gsf__try_result; \
    } while (0)

#define GSF__COUNT(array) (sizeof(array) / sizeof((array)[0]))

// Whether operations on doubles are rounded to double at once (not so on the x87).
#if defined(FLT_EVAL_METHOD)
#define GSF__PLAIN_DOUBLES (FLT_EVAL_METHOD == 0)
#else
#define GSF__PLAIN_DOUBLES 0
#endif

// MinGW's own, since the C runtime that it links has no %zu in some versions and rounds wrongly in others.
#if defined(__MINGW32__)
#define GSF__SNPRINTF __mingw_snprintf
#define GSF__VSNPRINTF __mingw_vsnprintf
#define GSF__STRTOD __mingw_strtod
#else
#define GSF__SNPRINTF snprintf
#define GSF__VSNPRINTF vsnprintf
#define GSF__STRTOD strtod
#endif

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

// Arrays that are freed together. gsf__arena_alloc returns NULL when out of memory and sets `failed`, so that one check
// after the last of them is enough.
typedef struct gsf__arena {
    gsf_context* ctx;
    void* last; // the array taken last; in front of each is a pointer to the one before
    int failed;
} gsf__arena;

enum { GSF__ARENA_HEAD = 64 }; // keeps the alignment

GSF__SHARED void* gsf__arena_alloc(gsf__arena* arena, size_t count, size_t size) {
    const size_t most = SIZE_MAX - GSF__ARENA_HEAD;
    size_t bytes;
    if (!gsf__mul_size(count, size, &bytes) || bytes > most) bytes = most; // which gsf_alloc refuses
    char* block = (char*)gsf_alloc(arena->ctx, 1, bytes + GSF__ARENA_HEAD);
    arena->failed |= !block;
    if (!block) return NULL;
    memcpy(block, &arena->last, sizeof arena->last);
    return arena->last = block + GSF__ARENA_HEAD;
}

GSF__SHARED void* gsf__arena_alloc_zeroed(gsf__arena* arena, size_t count, size_t size) {
    void* block = gsf__arena_alloc(arena, count, size);
    if (block) memset(block, 0, count * size);
    return block;
}

GSF__SHARED void gsf__arena_free(gsf__arena* arena) {
    while (arena->last) {
        char* block = (char*)arena->last - GSF__ARENA_HEAD;
        memcpy(&arena->last, block, sizeof arena->last);
        gsf_free(arena->ctx, block);
    }
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

GSF__SHARED double gsf__load_f64(const void* data) { // little-endian
    const uint64_t bits = gsf__load_le(data, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

GSF__SHARED void gsf__store_f64(void* data, double value) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    gsf__store_le(data, bits, 8);
}

// CRC-32 of gzip and PNG (reflected polynomial 0xedb88320), continued from `crc`, which starts as 0. Inputs of 32 KiB and
// more, which are worth building the tables, are processed 16 bytes at a time (slicing-by-16): tables[k][b] is the CRC of
// byte b followed by k zero bytes.
GSF__SHARED uint32_t gsf__crc32(uint32_t crc, const void* data, size_t size) {
    static const uint32_t nibble[16] = {0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u,
                                        0x4db26158u, 0x5005713cu, 0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
                                        0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
    const unsigned char* p = (const unsigned char*)data;
    crc = ~crc;
    if (size >= 1 << 15) {
        uint32_t tables[16][256];
        for (uint32_t b = 0; b < 256; b++) {
            const uint32_t half = nibble[b & 15u] ^ b >> 4;
            tables[0][b] = nibble[half & 15u] ^ half >> 4;
        }
        for (int k = 1; k < 16; k++)
            for (int b = 0; b < 256; b++)
                tables[k][b] = tables[0][tables[k - 1][b] & 255u] ^ tables[k - 1][b] >> 8;
        for (; size >= 16; size -= 16, p += 16) {
            const uint32_t w0 = crc ^ (uint32_t)gsf__load_le(p, 4), w1 = (uint32_t)gsf__load_le(p + 4, 4);
            const uint32_t w2 = (uint32_t)gsf__load_le(p + 8, 4), w3 = (uint32_t)gsf__load_le(p + 12, 4);
            crc = tables[15][w0 & 255u] ^ tables[14][w0 >> 8 & 255u] ^
                  tables[13][w0 >> 16 & 255u] ^ tables[12][w0 >> 24] ^
                  tables[11][w1 & 255u] ^ tables[10][w1 >> 8 & 255u] ^
                  tables[9][w1 >> 16 & 255u] ^ tables[8][w1 >> 24] ^
                  tables[7][w2 & 255u] ^ tables[6][w2 >> 8 & 255u] ^
                  tables[5][w2 >> 16 & 255u] ^ tables[4][w2 >> 24] ^
                  tables[3][w3 & 255u] ^ tables[2][w3 >> 8 & 255u] ^
                  tables[1][w3 >> 16 & 255u] ^ tables[0][w3 >> 24];
        }
    }
    for (size_t i = 0; i < size; i++) {
        crc = nibble[(crc ^ p[i]) & 15u] ^ (crc >> 4);
        crc = nibble[(crc ^ (uint32_t)(p[i] >> 4)) & 15u] ^ (crc >> 4);
    }
    return ~crc;
}

enum { GSF__DECIMAL_DIGITS = 800 }; // more than the 767 that can decide how a double rounds

// Reads [+-]digits[.digits][e[+-]digits] at the start of `text`. Correctly rounded and independent of the locale, because
// strtod only ever gets digits and an exponent. Returns the number of bytes read, 0 if there is no number. Overflow gives
// infinity.
GSF__SHARED size_t gsf__scan_double(const char* text, size_t size, double* out) {
    static const double powers[23] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                      1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
    char digits[GSF__DECIMAL_DIGITS + 32];
    size_t at = size && (text[0] == '-' || text[0] == '+'), kept = 0, seen = 0;
    int64_t exponent = 0;
    uint64_t mantissa = 0;
    int point = 0, lost = 0;
    for (; at < size; at++) {
        const char c = text[at];
        if (c == '.' && !point) { point = 1; continue; }
        if (c < '0' || c > '9') break;
        seen++;
        if (kept == GSF__DECIMAL_DIGITS) { // any further non-zero digit only breaks ties: see `lost` below
            lost |= c != '0';
            exponent += !point;
        } else {
            if (kept || c != '0') digits[kept++] = c;
            if (kept <= 19) mantissa = mantissa * 10 + (uint64_t)(c - '0');
            exponent -= point;
        }
    }
    if (!seen) return 0;
    if (at < size && (text[at] == 'e' || text[at] == 'E')) {
        size_t e = at + 1;
        const int minus = e < size && text[e] == '-';
        if (e < size && (text[e] == '-' || text[e] == '+')) e++;
        int64_t value = 0;
        for (; e < size && text[e] >= '0' && text[e] <= '9'; e++) {
            if (value < (int64_t)1 << 50) value = value * 10 + (text[e] - '0');
            at = e + 1;
        }
        exponent += minus ? -value : value;
    }
    double result = 0.0;
    if (kept == 0) {
        result = 0.0;
    } else if (GSF__PLAIN_DOUBLES && kept <= 19 && mantissa <= (uint64_t)1 << 53 && exponent >= -22 &&
               exponent <= 22) { // both operands are exact, so the result is rounded once
        result = exponent < 0 ? (double)mantissa / powers[-exponent] : (double)mantissa * powers[exponent];
    } else {
        if (lost) {
            digits[kept++] = '1';
            exponent--;
        }
        if (exponent > 9999) exponent = 9999;
        if (exponent < -9999) exponent = -9999;
        snprintf(digits + kept, sizeof digits - kept, "e%d", (int)exponent);
        result = GSF__STRTOD(digits, NULL);
    }
    *out = text[0] == '-' ? -result : result;
    return at;
}

// Length of the UTF-8 sequence at the start of `text`, 0 if it is not well-formed (Unicode Standard, table 3-7).
GSF__SHARED size_t gsf__utf8_size(const void* text, size_t left) {
    const unsigned char* p = (const unsigned char*)text;
    if (left == 0) return 0;
    const unsigned c = p[0];
    if (c < 0x80) return 1;
    const size_t size = c >= 0xc2 && c <= 0xdf ? 2 : c >= 0xe0 && c <= 0xef ? 3 : c >= 0xf0 && c <= 0xf4 ? 4 : 0;
    if (size == 0 || left < size) return 0;
    for (size_t i = 1; i < size; i++)
        if ((p[i] & 0xc0) != 0x80) return 0;
    if ((c == 0xe0 && p[1] < 0xa0) || (c == 0xed && p[1] > 0x9f) || (c == 0xf0 && p[1] < 0x90) ||
        (c == 0xf4 && p[1] > 0x8f))
        return 0; // overlong, a surrogate, or above U+10FFFF
    return size;
}

// IEEE half precision. To float is exact; from float rounds to nearest, ties to even, and overflows to infinity.
GSF__SHARED float gsf__half_to_float(uint16_t half) {
    const uint32_t sign = (uint32_t)(half & 0x8000u) << 16, exponent = half >> 10 & 31u, fraction = half & 1023u;
    uint32_t bits;
    if (exponent == 0) {
        const float tiny = (float)fraction * (1.0f / 16777216.0f); // subnormal: fraction * 2^-24
        memcpy(&bits, &tiny, sizeof bits);
    } else if (exponent == 31) {
        bits = 0x7f800000u | fraction << 13;
    } else {
        bits = (exponent + 112u) << 23 | fraction << 13;
    }
    bits |= sign;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

GSF__SHARED uint16_t gsf__float_to_half(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    const uint32_t sign = bits >> 16 & 0x8000u;
    bits &= 0x7fffffffu;
    if (bits > 0x7f800000u) return (uint16_t)(sign | 0x7e00u); // NaN
    if (bits >= 0x477ff000u) return (uint16_t)(sign | 0x7c00u); // 65520 and above round to infinity
    if (bits < 0x38800000u) { // subnormal: adding 0.5 leaves value * 2^24 in the low bits, rounded by the FPU
        float magnitude;
        memcpy(&magnitude, &bits, sizeof magnitude);
        magnitude += 0.5f;
        memcpy(&bits, &magnitude, sizeof bits);
        return (uint16_t)(sign | (bits - 0x3f000000u));
    }
    bits += 0xc8000fffu + (bits >> 13 & 1u); // rebias by -112, round half to even
    return (uint16_t)(sign | bits >> 13);
}

GSF__SHARED size_t gsf__dtype_size(gsf_dtype dtype) {
    switch (dtype) {
        case GSF_U8: return 1;
        case GSF_U16: return 2;
        case GSF_F16: return 2;
        case GSF_F32: return 4;
        case GSF_F64: return 8;
    }
    return 0;
}

// out = a * b for column-major 4x4 matrices; out may be a or b.
GSF__SHARED void gsf__mat4_mul(const double a[16], const double b[16], double out[16]) {
    double m[16];
    for (int c = 0; c < 4; c++)
        for (int r = 0; r < 4; r++) {
            double sum = 0.0;
            for (int k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
            m[4 * c + r] = sum;
        }
    memcpy(out, m, sizeof m);
}

// Inverse of a rigid transform; out may be m.
GSF__SHARED void gsf__mat4_rigid_inverse(const double m[16], double out[16]) {
    double inv[16];
    for (int c = 0; c < 3; c++) {
        for (int r = 0; r < 3; r++) inv[4 * c + r] = m[4 * r + c];
        inv[4 * c + 3] = 0.0;
    }
    for (int r = 0; r < 3; r++) inv[12 + r] = -(m[4 * r] * m[12] + m[4 * r + 1] * m[13] + m[4 * r + 2] * m[14]);
    inv[15] = 1.0;
    memcpy(out, inv, sizeof inv);
}

// Eigenvalues of a symmetric 3x3 matrix (row-major), descending, and unit eigenvectors as rows. Cyclic Jacobi:
// eigenvectors are products of plane rotations, so they are orthonormal up to rounding for any matrix.
GSF__SHARED void gsf__mat3_eigen(const double matrix[9], double values[3], double rows[9]) {
    double a[9], v[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    memcpy(a, matrix, sizeof a);
    for (int sweep = 0; sweep < 64; sweep++) {
        const double off = fabs(a[1]) + fabs(a[2]) + fabs(a[5]);
        if (!(off > 1e-300) || off < 1e-20 * (fabs(a[0]) + fabs(a[4]) + fabs(a[8]))) break;
        for (int p = 0; p < 2; p++)
            for (int q = p + 1; q < 3; q++) {
                const double apq = a[3 * p + q];
                if (apq == 0.0) continue;
                const double half = 0.5 * (a[4 * q] - a[4 * p]) / apq;
                const double t = (half < 0.0 ? -1.0 : 1.0) / (fabs(half) + sqrt(half * half + 1.0));
                const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
                const int r = 3 - p - q;
                const double arp = a[3 * r + p], arq = a[3 * r + q];
                a[4 * p] -= t * apq;
                a[4 * q] += t * apq;
                a[3 * p + q] = a[3 * q + p] = 0.0;
                a[3 * r + p] = a[3 * p + r] = c * arp - s * arq;
                a[3 * r + q] = a[3 * q + r] = s * arp + c * arq;
                for (int i = 0; i < 3; i++) {
                    const double vp = v[3 * p + i], vq = v[3 * q + i];
                    v[3 * p + i] = c * vp - s * vq;
                    v[3 * q + i] = s * vp + c * vq;
                }
            }
    }
    int order[3] = {0, 1, 2};
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2 - i; j++)
            if (a[4 * order[j]] < a[4 * order[j + 1]]) {
                const int swap = order[j];
                order[j] = order[j + 1];
                order[j + 1] = swap;
            }
    for (int i = 0; i < 3; i++) {
        values[i] = a[4 * order[i]];
        memcpy(rows + 3 * i, v + 3 * order[i], 3 * sizeof(double));
    }
}

GSF__SHARED void gsf__camera_transform(const gsf_camera* camera, const double point[3], double out[3]) {
    const double* m = camera->w2c;
    for (int r = 0; r < 3; r++) out[r] = m[r] * point[0] + m[4 + r] * point[1] + m[8 + r] * point[2] + m[12 + r];
}

// The count nearest to `wanted` out of least, least + step, ... up to `most` (0: no limit).
GSF__SHARED int32_t gsf__legal_count(int32_t wanted, int32_t least, int32_t most, int32_t step) {
    if (step < 1) step = 1;
    if (most > 0 && wanted > most) wanted = most;
    int32_t legal = wanted <= least ? least : least + (wanted - least + step / 2) / step * step;
    if (most > 0 && legal > most) legal -= step;
    return legal < least ? least : legal;
}

// The multiple of `multiple` nearest to `wanted`, up to `most` (0: no limit): a legal width or height.
GSF__SHARED int32_t gsf__legal_side(double wanted, int32_t multiple, int32_t most) {
    if (multiple < 1) multiple = 1;
    return gsf__legal_count((int32_t)(wanted + 0.5), multiple, most, multiple);
}

enum {
    GSF__CARRIED_IMAGES = 7,
    GSF__WINDOW_BYTES = offsetof(gsf_restore_window, carry_fn),  // of a host
    GSF__RESTORER_BYTES = offsetof(gsf_restorer, destroy_fn),    // that was written before the field existed
};

// The images of a gsf_carried in their order, and their channels.
GSF__SHARED void gsf__list_carried(gsf_carried* carried, gsf_image* images[GSF__CARRIED_IMAGES],
                              int32_t channels[GSF__CARRIED_IMAGES]) {
    static const int32_t counts[GSF__CARRIED_IMAGES] = {3, 3, 1, 1, 1, 3, 1};
    gsf_image* const list[GSF__CARRIED_IMAGES] = {&carried->color, &carried->residual, &carried->score, &carried->depth,
                                                  &carried->angle, &carried->back_color, &carried->back_ratio};
    memcpy(images, list, sizeof list);
    memcpy(channels, counts, sizeof counts);
}

// Unit quaternion (w x y z, w >= 0) of the rotation of a column-major rigid transform.
GSF__SHARED void gsf__quat_of(const double m[16], double quat[4]) {
    // Four times the squares of w, x, y, z; dividing by the largest is well conditioned (Shepperd 1978).
    const double s[4] = {1.0 + m[0] + m[5] + m[10], 1.0 + m[0] - m[5] - m[10], 1.0 - m[0] + m[5] - m[10],
                         1.0 - m[0] - m[5] + m[10]};
    int most = 0;
    for (int i = 1; i < 4; i++)
        if (s[i] > s[most]) most = i;
    double q[4];
    switch (most) {
        case 0: q[0] = s[0]; q[1] = m[6] - m[9]; q[2] = m[8] - m[2]; q[3] = m[1] - m[4]; break;
        case 1: q[0] = m[6] - m[9]; q[1] = s[1]; q[2] = m[1] + m[4]; q[3] = m[8] + m[2]; break;
        case 2: q[0] = m[8] - m[2]; q[1] = m[1] + m[4]; q[2] = s[2]; q[3] = m[6] + m[9]; break;
        default: q[0] = m[1] - m[4]; q[1] = m[8] + m[2]; q[2] = m[6] + m[9]; q[3] = s[3]; break;
    }
    const double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double scale = (q[0] < 0.0 ? -1.0 : 1.0) / length;
    for (int i = 0; i < 4; i++) quat[i] = q[i] * scale;
}

typedef gsf_result (*gsf__carry_fn)(void* carry_user, gsf_context* ctx, int32_t frame, int32_t slot, gsf_carried* out);

// The window's carry_fn; NULL also if an older host's window ends before it.
GSF__SHARED gsf__carry_fn gsf__carry_fn_of(const gsf_restore_window* window) {
    return window->struct_size >= sizeof *window ? window->carry_fn : NULL;
}

// Result for the errno of a failed gsf__open_path. A path below a regular file (ENOTDIR) does not exist either.
GSF__SHARED gsf_result gsf__open_result(int reason) {
    if (reason == ENOMEM) return GSF_ERROR_OUT_OF_MEMORY;
    return reason == ENOENT || reason == ENOTDIR ? GSF_ERROR_NOT_FOUND : GSF_ERROR_IO;
}

// ---- platform: clock, text, files. All paths are UTF-8; on failure the functions return -1 or NULL and set errno.

typedef enum gsf__path_kind { GSF__PATH_UNKNOWN, GSF__PATH_FILE, GSF__PATH_FOLDER, GSF__PATH_DEVICE } gsf__path_kind;
typedef enum gsf__open_mode { // WRITE is for devices; NEW fails if there is anything of that name, even a link
    GSF__OPEN_READ, GSF__OPEN_WRITE, GSF__OPEN_NEW
} gsf__open_mode;

#if defined(_WIN32)

GSF__SHARED double gsf__seconds(void) { // of a clock that only goes forward; for statistics only
    LARGE_INTEGER ticks, per_second;
    QueryPerformanceCounter(&ticks);
    QueryPerformanceFrequency(&per_second);
    return (double)ticks.QuadPart / (double)per_second.QuadPart;
}

GSF__SHARED int gsf__seek(FILE* file, int64_t offset, int from) { return _fseeki64(file, offset, from); }
GSF__SHARED int64_t gsf__tell(FILE* file) { return _ftelli64(file); }

GSF__SHARED int gsf__set_errno(DWORD reason) {
    switch (reason) {
        case ERROR_FILE_NOT_FOUND:
        case ERROR_PATH_NOT_FOUND:
        case ERROR_INVALID_NAME:
        case ERROR_BAD_NETPATH:
        case ERROR_INVALID_DRIVE: errno = ENOENT; break;
        case ERROR_ACCESS_DENIED:
        case ERROR_WRITE_PROTECT: errno = EACCES; break;
        case ERROR_SHARING_VIOLATION:
        case ERROR_LOCK_VIOLATION: errno = EBUSY; break;
        case ERROR_FILE_EXISTS:
        case ERROR_ALREADY_EXISTS: errno = EEXIST; break;
        case ERROR_DISK_FULL:
        case ERROR_HANDLE_DISK_FULL: errno = ENOSPC; break;
        case ERROR_FILENAME_EXCED_RANGE: errno = ENAMETOOLONG; break;
        case ERROR_DIRECTORY: errno = ENOTDIR; break;
        default: errno = EIO;
    }
    return -1;
}

enum { GSF__SHORT_PATH = 240 }; // in UTF-16 units; longer ones need the form \\?\, which no other program has to understand

typedef struct gsf__wide { // a path for the W functions
    wchar_t* text; // NULL: it is not UTF-8, or memory is out (errno)
    wchar_t* owned;
    wchar_t inside[GSF__SHORT_PATH + 1];
} gsf__wide;

GSF__SHARED void gsf__free_wide(gsf_context* ctx, gsf__wide* wide) { // keeps errno and the system's last error
    const int reason = errno;
    const DWORD last = GetLastError();
    gsf_free(ctx, wide->owned);
    SetLastError(last);
    errno = reason;
}

// The absolute path in the form \\?\, after 8 units that the prefix may need.
GSF__SHARED void gsf__lengthen_path(gsf_context* ctx, const wchar_t* path, gsf__wide* out) {
    const DWORD room = GetFullPathNameW(path, 0, NULL, NULL); // with the zero
    errno = ENOMEM;
    out->owned = (wchar_t*)gsf_alloc(ctx, (size_t)room + 8, sizeof *out->owned);
    const DWORD used = out->owned ? GetFullPathNameW(path, room, out->owned + 8, NULL) : 0;
    if (used == 0 || used >= room) return;
    const wchar_t* full = out->owned + 8;
    const int network = full[0] == L'\\' && full[1] == L'\\'; // \\server\share becomes \\?\UNC\server\share
    const size_t length = network ? 7 : 4;
    memmove(out->owned + length, full + network, ((size_t)used + 1 - (size_t)network) * sizeof *full);
    memcpy(out->owned, network ? L"\\\\?\\UNC" : L"\\\\?\\", length * sizeof *full);
    out->text = out->owned;
}

GSF__SHARED void gsf__widen_path(gsf_context* ctx, const char* path, gsf__wide* out) { // end with gsf__free_wide
    out->text = out->owned = NULL;
    const int size = MultiByteToWideChar(CP_UTF8, MB_ERR_INVALID_CHARS, path, -1, NULL, 0);
    errno = ENOENT; // no file can have such a name
    if (size < 1) return;
    wchar_t* long_path = NULL;
    wchar_t* wide = out->inside;
    if (size > GSF__SHORT_PATH) {
        errno = ENOMEM;
        wide = long_path = (wchar_t*)gsf_alloc(ctx, (size_t)size, sizeof *wide);
        if (!wide) return;
    }
    MultiByteToWideChar(CP_UTF8, 0, path, -1, wide, size);
    const int verbatim = wide[0] == L'\\' && wide[1] == L'\\' && (wide[2] == L'?' || wide[2] == L'.');
    if (verbatim || GetFullPathNameW(wide, 0, NULL, NULL) <= GSF__SHORT_PATH) { // a long one may become short: a/../b
        out->text = wide;
        out->owned = long_path;
        return;
    }
    gsf__lengthen_path(ctx, wide, out);
    gsf_free(ctx, long_path);
}

GSF__SHARED gsf__path_kind gsf__look_at_path(gsf_context* ctx, const char* path) {
    gsf__wide wide;
    gsf__widen_path(ctx, path, &wide);
    if (!wide.text) return gsf__free_wide(ctx, &wide), GSF__PATH_UNKNOWN;
    const DWORD attributes = GetFileAttributesW(wide.text);
    gsf__path_kind kind = GSF__PATH_UNKNOWN;
    HANDLE file = INVALID_HANDLE_VALUE;
    if (attributes != INVALID_FILE_ATTRIBUTES && (attributes & FILE_ATTRIBUTE_DIRECTORY)) kind = GSF__PATH_FOLDER;
    else
        file = CreateFileW(wide.text, 0, FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE, NULL, OPEN_EXISTING, 0, NULL);
    if (file != INVALID_HANDLE_VALUE) {
        kind = GetFileType(file) == FILE_TYPE_DISK ? GSF__PATH_FILE : GSF__PATH_DEVICE;
        CloseHandle(file);
    }
    gsf__free_wide(ctx, &wide);
    return kind;
}

// Waits before a file that somebody else has open is tried again; about a second in all. Returns 0 when that is over.
GSF__SHARED int gsf__wait_for_path(int attempt) {
    if (attempt >= 40) return 0;
    Sleep(attempt < 8 ? 2 : 30);
    return 1;
}

// Others may read, replace and remove the file meanwhile, as on other platforms.
GSF__SHARED HANDLE gsf__open_handle(gsf_context* ctx, const char* path, DWORD access, DWORD how, DWORD flags) {
    gsf__wide wide;
    gsf__widen_path(ctx, path, &wide);
    HANDLE file = INVALID_HANDLE_VALUE;
    for (int attempt = 0; wide.text; attempt++) {
        file = CreateFileW(wide.text, access, FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE, NULL, how, flags, NULL);
        const DWORD reason = GetLastError();
        if (file != INVALID_HANDLE_VALUE) break;
        gsf__set_errno(reason);
        if (reason != ERROR_SHARING_VIOLATION || !gsf__wait_for_path(attempt)) break;
    }
    gsf__free_wide(ctx, &wide);
    return file;
}

GSF__SHARED FILE* gsf__open_path(gsf_context* ctx, const char* path, gsf__open_mode mode) {
    const int reads = mode == GSF__OPEN_READ;
    HANDLE handle = gsf__open_handle(ctx, path, reads ? GENERIC_READ : GENERIC_WRITE, mode == GSF__OPEN_NEW ? CREATE_NEW :
                                     OPEN_EXISTING, FILE_ATTRIBUTE_NORMAL);
    if (handle == INVALID_HANDLE_VALUE) return NULL;
    const int descriptor = _open_osfhandle((intptr_t)handle, reads ? _O_RDONLY | _O_BINARY : _O_BINARY);
    FILE* file = descriptor < 0 ? NULL : _fdopen(descriptor, reads ? "rb" : "wb");
    if (!file && descriptor >= 0) _close(descriptor);
    else if (!file) CloseHandle(handle);
    return file;
}

// A virus scanner or a reader of the old file makes it fail for a moment, in which the old file stays as it is.
GSF__SHARED int gsf__replace_path(gsf_context* ctx, const char* from, const char* to) {
    gsf__wide wide_from, wide_to;
    gsf__widen_path(ctx, from, &wide_from);
    gsf__widen_path(ctx, to, &wide_to);
    int result = -1;
    for (int attempt = 0; wide_from.text && wide_to.text && result != 0; attempt++) {
        if (MoveFileExW(wide_from.text, wide_to.text, MOVEFILE_REPLACE_EXISTING | MOVEFILE_WRITE_THROUGH)) result = 0;
        const DWORD reason = GetLastError();
        if (result == 0) break;
        gsf__set_errno(reason);
        const DWORD there = GetFileAttributesW(wide_to.text); // a folder or a protected file will not give way
        const int lasting = there != INVALID_FILE_ATTRIBUTES && (there & (FILE_ATTRIBUTE_DIRECTORY | FILE_ATTRIBUTE_READONLY));
        if ((reason != ERROR_SHARING_VIOLATION && reason != ERROR_ACCESS_DENIED) || lasting || !gsf__wait_for_path(attempt))
            break;
    }
    gsf__free_wide(ctx, &wide_from);
    gsf__free_wide(ctx, &wide_to);
    return result;
}

GSF__SHARED void gsf__remove_path(gsf_context* ctx, const char* path) {
    gsf__wide wide;
    gsf__widen_path(ctx, path, &wide);
    if (wide.text) DeleteFileW(wide.text);
    gsf__free_wide(ctx, &wide);
}

#else

GSF__SHARED double gsf__seconds(void) { // for statistics only
#ifdef TIME_UTC
    struct timespec t;
    return timespec_get(&t, TIME_UTC) ? (double)t.tv_sec + 1e-9 * (double)t.tv_nsec : 0.0;
#else
    return (double)clock() / (double)CLOCKS_PER_SEC;
#endif
}

GSF__SHARED int gsf__seek(FILE* file, int64_t offset, int from) { return fseek(file, (long)offset, from); }
GSF__SHARED int64_t gsf__tell(FILE* file) { return ftell(file); }

GSF__SHARED gsf__path_kind gsf__look_at_path(gsf_context* ctx, const char* path) {
    (void)ctx;
#if defined(__unix__) || defined(__APPLE__)
    struct stat info;
    if (stat(path, &info) != 0) return GSF__PATH_UNKNOWN;
    return S_ISREG(info.st_mode) ? GSF__PATH_FILE : S_ISDIR(info.st_mode) ? GSF__PATH_FOLDER : GSF__PATH_DEVICE;
#else
    (void)path;
    return GSF__PATH_UNKNOWN;
#endif
}

GSF__SHARED FILE* gsf__open_path(gsf_context* ctx, const char* path, gsf__open_mode mode) {
    (void)ctx;
    return fopen(path, mode == GSF__OPEN_READ ? "rb" : mode == GSF__OPEN_WRITE ? "wb" : "wbx");
}

GSF__SHARED int gsf__replace_path(gsf_context* ctx, const char* from, const char* to) {
    (void)ctx;
    return rename(from, to);
}

GSF__SHARED void gsf__remove_path(gsf_context* ctx, const char* path) {
    (void)ctx;
    remove(path);
}

#endif

enum { GSF__CHUNK_FILE_HEAD = 12, GSF__CHUNK_HEAD = 12, GSF__CHUNK_TAIL = 4 };

// Begins a chunk whose bytes are then appended to `out` piece by piece with gsf_append_bytes. Returns the position that
// gsf__close_chunk takes.
GSF__SHARED size_t gsf__open_chunk(gsf_context* ctx, gsf_buffer* out, const char* tag) {
    char head[GSF__CHUNK_HEAD]; // also holds the file header, which has the same size
    if (out->size == 0) {
        memcpy(head, "GSFCHUNK", 8);
        gsf__store_le(head + 8, 1, 4);
        gsf_append_bytes(ctx, out, head, GSF__CHUNK_FILE_HEAD);
    }
    const size_t opened = out->size;
    memset(head, 0, sizeof head); // gsf__close_chunk fills in the size
    memcpy(head, tag, 4);
    gsf_append_bytes(ctx, out, head, GSF__CHUNK_HEAD);
    return opened;
}

GSF__SHARED void gsf__close_chunk(gsf_context* ctx, gsf_buffer* out, size_t opened) {
    char crc[GSF__CHUNK_TAIL];
    if (out->failed) return;
    gsf__store_le(out->data + opened + 4, out->size - opened - GSF__CHUNK_HEAD, 8);
    gsf__store_le(crc, gsf__crc32(0, out->data + opened, out->size - opened), 4);
    gsf_append_bytes(ctx, out, crc, sizeof crc);
}

// Functions of gsfixer.h's implementation that other modules use. A module may be compiled in another file or library, so
// it calls them through the context; this way no internal function is ever exported.
typedef struct gsf__services {
    gsf_result (*inflate_fn)(gsf_context* ctx, const char* name, const void* data, size_t size, size_t body, void* out,
                             size_t room);
    gsf_result (*deflate_fn)(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_buffer* out);
    gsf_result (*parse_json_fn)(gsf_context* ctx, const char* name, const char* text, size_t size, size_t start,
                                gsf_json* out);
    gsf_result (*read_fn)(void* user, gsf_context* ctx, const char* path, void** data, size_t* size); // of the default io hook
} gsf__services;

// Inflates the DEFLATE stream (RFC 1951) that starts at byte `body` of a file into exactly `room` > 0 bytes. stb does it:
// at most 2^31 - 1 bytes, compressed or not; GSF_ERROR_UNSUPPORTED beyond that and under GSF_NO_STB. At least 8 bytes, such
// as the trailer of a gzip file, must follow the stream within `size`: stb 2.27 reads ahead and otherwise takes a complete
// stream for a truncated one.
GSF__SHARED gsf_result gsf__inflate(gsf_context* ctx, const char* name, const void* data, size_t size, size_t body,
                                    void* out, size_t room) {
    return ctx->services->inflate_fn(ctx, name, data, size, body, out, room);
}

// Appends `data` (0 < size <= 2^30) as a DEFLATE stream; the bytes are the same on every machine.
GSF__SHARED gsf_result gsf__deflate(gsf_context* ctx, const char* name, const void* data, size_t size,
                                    gsf_buffer* out) {
    return ctx->services->deflate_fn(ctx, name, data, size, out);
}

/* gzip (RFC 1952) around DEFLATE:
       1f 8b 08 flags | mtime 4 | xfl | os | [extra] [name] [comment] [crc16] |
       DEFLATE | crc32 4 | size modulo 2^32 4 */

enum { GSF__DEFLATE_RATIO = 1032 }; // upper bound of DEFLATE's compression ratio

GSF__SHARED gsf_result gsf__gzip_read_head(gsf_context* ctx, const char* name, const unsigned char* p, size_t size,
                                           size_t* body) {
    size_t at = 10;
    if (size < 2 || p[0] != 0x1f || p[1] != 0x8b)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: not gzip (1f 8b expected)", name);
    if (size < 18) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file is cut", name, size);
    if (p[2] != 8 || (p[3] & 0xe0) != 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:2: gzip method %d, flags %d: not supported", name, p[2], p[3]);
    if (p[3] & 4) at += 2 + (size_t)gsf__load_le(p + 10, 2);
    for (int text = 8; text <= 16; text *= 2) // optional NUL-terminated name and comment
        if (p[3] & text) {
            while (at < size && p[at]) at++;
            at++;
        }
    if (p[3] & 2) at += 2;
    if (at > size - 8) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file is cut inside the gzip header", name, size);
    *body = at;
    return GSF_OK;
}

// Inflates a gzip file into *out (freed by the caller), *out_size > 0 bytes. The size comes from the file's trailer; it
// is rejected when DEFLATE could not have compressed that much into a file of this size.
GSF__SHARED gsf_result gsf__gzip_read(gsf_context* ctx, const char* name, const unsigned char* data, size_t size,
                                      unsigned char** out, size_t* out_size) {
    size_t body = 0;
    *out = NULL;
    *out_size = 0;
    GSF__TRY(gsf__gzip_read_head(ctx, name, data, size, &body));
    const size_t whole = (size_t)gsf__load_le(data + size - 4, 4);
    if (whole == 0) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: gzip file without content", name, size - 4);
    if (whole / GSF__DEFLATE_RATIO > size - body - 8)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %zu bytes of content claimed, more than %zu can inflate to", name,
                        size - 4, whole, size - body - 8);
    unsigned char* content = (unsigned char*)gsf_alloc(ctx, whole, 1);
    if (!content) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = gsf__inflate(ctx, name, data, size, body, content, whole);
    if (result == GSF_OK && gsf__load_le(data + size - 8, 4) != gsf__crc32(0, content, whole))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: checksum mismatch", name, size - 8);
    if (result != GSF_OK) {
        gsf_free(ctx, content);
        return result;
    }
    *out = content;
    *out_size = whole;
    return GSF_OK;
}

// Parses JSON that begins at byte `start` of a file. Offsets, including those in error messages, count from the start of
// the file.
GSF__SHARED gsf_result gsf__parse_json_from(gsf_context* ctx, const char* name, const char* text, size_t size,
                                            size_t start, gsf_json* out) {
    return ctx->services->parse_json_fn(ctx, name, text, size, start, out);
}

// Whether paths name ordinary files of the platform, so that folders can be listed and files mapped or read in part.
GSF__SHARED int gsf__io_is_plain(const gsf_context* ctx) {
    return ctx->io.read_fn == ctx->services->read_fn || ctx->io.plain_files;
}

// ---- >>maths: functions with the same bits everywhere -----------------------------

/* The C libraries of Linux, Windows, Arm and the browsers differ in the last bits of exp, log, sin and so on, and glibc's in
   those of machines with and without FMA. What a scene's training depends on is therefore computed here, by additions,
   multiplications, divisions and sqrt, which IEEE 754 defines to the bit. Errors are below 1 ulp of double unless a comment
   says otherwise; the rounding mode has to be the default (to nearest). */

#define GSF__LN2_HIGH 0.693147180369123816490 // its last 32 bits are 0: a product with an exponent is exact
#define GSF__LN2_LOW 1.90821492927058770002e-10
#define GSF__TO_INT 6755399441055744.0        // 1.5 * 2^52: added and subtracted, it rounds to the nearest integer

GSF__SHARED double gsf__power_of_2(int n) { // -1022 <= n <= 1023
    const uint64_t bits = (uint64_t)(n + 1023) << 52;
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

// 1 + r + r^2/2 + ... for |r| <= ln(2)/2, without its first term.
GSF__SHARED double gsf__exp_series(double r) {
    double p = 1.0 / 6227020800.0;
    p = p * r + 1.0 / 479001600.0;
    p = p * r + 1.0 / 39916800.0;
    p = p * r + 1.0 / 3628800.0;
    p = p * r + 1.0 / 362880.0;
    p = p * r + 1.0 / 40320.0;
    p = p * r + 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    return p * r * r + r;
}

GSF__SHARED double gsf__exp_f64(double x) {
    if (!(x < 710.0)) return x != x ? x : (double)INFINITY;
    if (x < -746.0) return 0.0;
    const double n = x * 1.44269504088896338700 + GSF__TO_INT - GSF__TO_INT;
    const double high = x - n * GSF__LN2_HIGH, low = n * GSF__LN2_LOW, r = high - low;
    const double p = 1.0 + (gsf__exp_series(r) + ((high - r) - low));
    const int k = (int)n, half = k / 2;
    return p * gsf__power_of_2(half) * gsf__power_of_2(k - half); // in two steps: 2^k may be subnormal
}

GSF__SHARED double gsf__expm1_f64(double x) {
    return fabs(x) < 0.34 ? gsf__exp_series(x) : gsf__exp_f64(x) - 1.0;
}

// log(x + low), where low is negligible next to x but for the last bits.
GSF__SHARED double gsf__log_sum(double x, double low) {
    if (!(x > 0.0) || x > DBL_MAX) return x == 0.0 ? -(double)INFINITY : x > 0.0 || x != x ? x : (double)NAN;
    int64_t bits;
    int shift = 0;
    if (x < DBL_MIN) x *= 18014398509481984.0, low *= 18014398509481984.0, shift = 54;
    memcpy(&bits, &x, sizeof bits);
    const int64_t k = (bits - 0x3fe6a09e667f3bcd) >> 52; // from sqrt(1/2): the mantissa ends up in [sqrt(1/2), sqrt(2))
    bits -= k * ((int64_t)1 << 52);
    double m;
    memcpy(&m, &bits, sizeof m);
    const double f = m - 1.0, n = (double)(k - shift), s = f / (2.0 + f), z = s * s; // log(m) = 2 artanh(s)
    double p = 2.0 / 25.0;
    p = p * z + 2.0 / 23.0;
    p = p * z + 2.0 / 21.0;
    p = p * z + 2.0 / 19.0;
    p = p * z + 2.0 / 17.0;
    p = p * z + 2.0 / 15.0;
    p = p * z + 2.0 / 13.0;
    p = p * z + 2.0 / 11.0;
    p = p * z + 2.0 / 9.0;
    p = p * z + 2.0 / 7.0;
    p = p * z + 2.0 / 5.0;
    p = p * z + 2.0 / 3.0;
    const double half = 0.5 * f * f;
    return n * GSF__LN2_HIGH - ((half - (s * (half + p * z) + (n * GSF__LN2_LOW + low / x))) - f);
}

GSF__SHARED double gsf__log_f64(double x) { return gsf__log_sum(x, 0.0); }

GSF__SHARED double gsf__log1p_f64(double x) {
    const double sum = 1.0 + x;
    if (sum == 1.0) return x;
    return gsf__log_sum(sum, fabs(x) < 1.0 ? x - (sum - 1.0) : 1.0 - (sum - x));
}

// x^n by squaring; the relative error grows with n, to n ulp at most.
GSF__SHARED double gsf__power_f64(double x, uint64_t n) {
    double power = 1.0;
    for (; n; n >>= 1, x *= x)
        if (n & 1u) power *= x;
    return power;
}

// The multiple of pi/2 next to x, and the rest as a sum. Beyond a million the result is less exact than a double.
GSF__SHARED int gsf__quadrant(double x, double* rest, double* low) {
    const double n = x * 0.636619772367581382433 + GSF__TO_INT - GSF__TO_INT;
    const double r = x - n * 1.57079632673412561417, w = n * 6.07710050630396597660e-11; // 33 bits each: exact
    const double s = r - w, v = n * 2.02226624879595063154e-21 - ((r - s) - w);
    *rest = s - v;
    *low = (s - *rest) - v;
    return (int)((int64_t)n & 3);
}

GSF__SHARED double gsf__sin_series(double x, double low) { // |x| <= pi/4
    const double z = x * x;
    double p = 1.0 / 355687428096000.0;
    p = 1.0 / 1307674368000.0 - p * z;
    p = 1.0 / 6227020800.0 - p * z;
    p = 1.0 / 39916800.0 - p * z;
    p = 1.0 / 362880.0 - p * z;
    p = 1.0 / 5040.0 - p * z;
    p = 1.0 / 120.0 - p * z;
    p = 1.0 / 6.0 - p * z;
    return x - (p * z * x - low * (1.0 - 0.5 * z));
}

GSF__SHARED double gsf__cos_series(double x, double low) { // |x| <= pi/4
    const double z = x * x, half = 0.5 * z, rest = 1.0 - half;
    double p = 1.0 / 6402373705728000.0;
    p = 1.0 / 20922789888000.0 - p * z;
    p = 1.0 / 87178291200.0 - p * z;
    p = 1.0 / 479001600.0 - p * z;
    p = 1.0 / 3628800.0 - p * z;
    p = 1.0 / 40320.0 - p * z;
    p = 1.0 / 720.0 - p * z;
    p = 1.0 / 24.0 - p * z;
    return rest + (((1.0 - rest) - half) + (p * z * z - x * low));
}

GSF__SHARED double gsf__turn(double x, int quarters) { // sin(x + quarters * pi/2)
    double rest, low;
    if (!(fabs(x) < 1e9)) return x != x || fabs(x) > DBL_MAX ? (double)NAN : 0.0;
    const int quadrant = (gsf__quadrant(x, &rest, &low) + quarters) & 3;
    const double value = quadrant & 1 ? gsf__cos_series(rest, low) : gsf__sin_series(rest, low);
    return quadrant & 2 ? -value : value;
}

// Of arguments below 1e9, beyond which they have no use here (and are 0).
GSF__SHARED double gsf__sin_f64(double x) { return gsf__turn(x, 0); }
GSF__SHARED double gsf__cos_f64(double x) { return gsf__turn(x, 1); }
GSF__SHARED double gsf__tan_f64(double x) { return gsf__turn(x, 0) / gsf__turn(x, 1); } // to 2 ulp

GSF__SHARED double gsf__atan_unit(double x) { // 0 <= x <= 1; to 1.5 ulp
    static const double centers[3] = {0.0, 0.5, 1.0};
    static const double angles[3] = {0.0, 4.63647609000806093515e-01, 7.85398163397448278999e-01};
    static const double rests[3] = {0.0, 2.26987774529616870924e-17, 3.06161699786838301793e-17};
    const int k = x < 0.25 ? 0 : x < 0.75 ? 1 : 2;
    const double t = (x - centers[k]) / (1.0 + x * centers[k]), z = t * t; // |t| <= 1/4
    double p = 1.0 / 27.0;
    for (int i = 25; i >= 3; i -= 2) p = 1.0 / (double)i - p * z;
    return angles[k] + (t - (p * z * t - rests[k]));
}

GSF__SHARED double gsf__atan2_f64(double y, double x) { // to 2 ulp; 0 for two zeros
    const double ax = fabs(x), ay = fabs(y), most = ax > ay ? ax : ay, least = ax > ay ? ay : ax;
    if (x != x || y != y) return x + y;
    double angle = most > 0.0 && least < (double)INFINITY ? gsf__atan_unit(least / most) : 0.0;
    if (ay > ax) angle = 1.57079632679489655800 - (angle - 6.12323399573676603587e-17);
    if (x < 0.0) angle = 3.14159265358979311600 - (angle - 1.2246467991473531772e-16);
    return y < 0.0 ? -angle : angle;
}

GSF__SHARED double gsf__acos_f64(double x) { // to 3 ulp
    return x != x ? x : 2.0 * gsf__atan2_f64(sqrt(x < 1.0 ? 1.0 - x : 0.0), sqrt(x > -1.0 ? 1.0 + x : 0.0));
}

GSF__SHARED double gsf__cbrt_f64(double x) { // to 2 ulp
    if (!(fabs(x) > 0.0) || fabs(x) > DBL_MAX) return x;
    const double a = fabs(x);
    double root = gsf__exp_f64(gsf__log_f64(a) / 3.0);
    root -= (root * root * root - a) / (3.0 * root * root);
    return x < 0.0 ? -root : root;
}

// Of floats: rounded from double, and so nearly always correctly.
GSF__SHARED float gsf__exp_f32(float x) { return (float)gsf__exp_f64((double)x); }
GSF__SHARED float gsf__log_f32(float x) { return (float)gsf__log_f64((double)x); }

GSF__SHARED double gsf__pow_f64(double x, double y) { return gsf__exp_f64(gsf__log_f64(x) * y); } // x > 0

// The sRGB transfer function and its inverse; linear below 0.
GSF__SHARED void gsf__transfer_colors(double* values, size_t count, gsf_color_space to) {
    for (size_t i = 0; i < count; i++) {
        const double v = values[i];
        if (to == GSF_COLOR_SRGB) values[i] = v <= 0.0031308 ? 12.92 * v : 1.055 * gsf__pow_f64(v, 1.0 / 2.4) - 0.055;
        else values[i] = v <= 0.04045 ? v / 12.92 : gsf__pow_f64((v + 0.055) / 1.055, 2.4);
    }
}

GSF__SHARED float gsf__exp2_f32(float x) {
    if (!(x < 128.0f)) return x != x ? x : INFINITY;
    if (x < -150.0f) return 0.0f;
    const double n = (double)x + GSF__TO_INT - GSF__TO_INT, r = ((double)x - n) * 0.69314718055994530942;
    double p = 1.0 / 3628800.0; // to 1e-12: |r| <= ln(2)/2
    p = p * r + 1.0 / 362880.0;
    p = p * r + 1.0 / 40320.0;
    p = p * r + 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    return (float)((p * r * r + r + 1.0) * gsf__power_of_2((int)n));
}

// ---- >>lanes: the vector vocabulary --------------------------------------------

/* An elementwise kernel is written once, in terms of the names below, and compiled once per instruction set: its header
   includes itself with the kernel's section selected and GSF__ISA set to scalar, avx2 or avx512. Kernels are ordinary code
   rather than macro bodies, so a debugger can step through each copy. In a module:

       #ifndef GSF__ISA                         // everything else, compiled once
       ...
       #define GSF__KERNELS "gsfixer_x.h"       // the file with the kernels
       #define GSF__KERNELS_BLUR                // the section to compile
       #define GSF__KERNELS_AVX512              // optional: compile a 16-lane copy, too
       #define GSF__KERNELS_SIMD128             // optional: compile a 4-lane copy for Arm and WebAssembly
       #include "gsfixer.h"                     // includes gsfixer_x.h once per instruction set
       #undef GSF__KERNELS_BLUR
       #endif
       #ifdef GSF__KERNELS_BLUR                 // the kernels: gsf__blur_scalar, gsf__blur_avx2, gsf__blur_avx512
       GSF__V_KERNEL void GSF__V(gsf__blur)(const float* x, size_t n, float* y) {
           for (size_t i = 0; i < n; i += GSF__LANES) {
               const gsf__vf v = gsf__v_load_first(x + i, n - i);
               gsf__v_store_first(y + i, gsf__v_madd(v, gsf__v_set(0.5f), v), n - i);
           }
       }
       #endif

   An inclusion takes the preprocessor through the whole file once per instruction set, so sections that are far apart share
   one where the types that they need allow it: gcc slows down once a unit has passed it more than 300,000 lines.

   Types       gsf__vf  GSF__LANES floats      gsf__vi  GSF__LANES int32_t     gsf__vm  mask, one bool per lane
               gsf__vd  GSF__LANES / GSF__HALVES doubles
   Names       gsf__v_ operates on floats, gsf__vi_, gsf__vm_ and gsf__vd_ on the other types. + - * / work on gsf__vf and
               gsf__vd, which are plain float and double or vector types for which GCC and Clang define operators (another
               compiler would need C++ overloads). No other vector extension is used.
   madd        a * b + c; msub: a * b - c; nmadd: c - a * b. Fused if GSF__FUSED, that is, except in the scalar version and on
               WebAssembly, which has no such instruction.
   min, max    return b if either operand is a NaN: max(limit, x) propagates a NaN in x, max(x, limit) replaces it.
   _first      reads or writes only the first n lanes (all if n >= GSF__LANES); other lanes are loaded as 0.
   sum         adds the upper half to the lower until one lane is left; 8 lanes: ((0+4)+(2+6)) + ((1+5)+(3+7)).

   To add an instruction set, define all names with a new suffix and include the kernels once more at the end of this
   file. */

#define GSF__PASTE_(a, b) a##_##b
#define GSF__PASTE(a, b) GSF__PASTE_(a, b)
#define GSF__V(name) GSF__PASTE(name, GSF__ISA)    // `name` for the instruction set being compiled
#define GSF__V_KERNEL GSF__V(GSF__V_KERNEL) static // begins the definition of a kernel
#define GSF__V_INLINE GSF__V(GSF__V_INLINE)        // begins the definition of a function to be inlined into kernels
#define GSF__LANES GSF__V(GSF__LANES)
#define GSF__HALVES GSF__V(GSF__HALVES)
#define GSF__FUSED GSF__V(GSF__FUSED)

// The copy of a kernel, or of a constant, for a CPU level. WIDE: of one that has an AVX-512 copy, too; LANE: a 4-lane copy
// (GSF__KERNELS_SIMD128); ANY: both.
#if GSF__X86
#define GSF__KERNEL_OF(level, name) ((level) >= GSF_CPU_AVX2 ? name##_avx2 : name##_scalar)
#define GSF__WIDE_KERNEL_OF(level, name) \
    (GSF__REACHES(level, AVX512) ? name##_avx512 : (level) >= GSF_CPU_AVX2 ? name##_avx2 : name##_scalar)
#define GSF__LANE_KERNEL_OF GSF__KERNEL_OF
#define GSF__ANY_KERNEL_OF GSF__WIDE_KERNEL_OF
#elif GSF__SIMD128
#define GSF__KERNEL_OF(level, name) ((void)(level), name##_scalar)
#define GSF__WIDE_KERNEL_OF GSF__KERNEL_OF
#define GSF__ANY_KERNEL_OF GSF__LANE_KERNEL_OF
#define GSF__LANE_KERNEL_OF(level, name) ((level) == GSF_CPU_SIMD128 ? name##_simd128 : name##_scalar)
#else
#define GSF__KERNEL_OF(level, name) ((void)(level), name##_scalar)
#define GSF__WIDE_KERNEL_OF GSF__KERNEL_OF
#define GSF__LANE_KERNEL_OF GSF__KERNEL_OF
#define GSF__ANY_KERNEL_OF GSF__KERNEL_OF
#endif

#define gsf__vf GSF__V(gsf__vf)
#define gsf__vi GSF__V(gsf__vi)
#define gsf__vm GSF__V(gsf__vm)
#define gsf__vd GSF__V(gsf__vd)

#define gsf__v_set GSF__V(gsf__v_set)
#define gsf__v_load GSF__V(gsf__v_load)
#define gsf__v_store GSF__V(gsf__v_store)
#define gsf__v_load_first GSF__V(gsf__v_load_first)
#define gsf__v_store_first GSF__V(gsf__v_store_first)
#define gsf__v_load_bytes GSF__V(gsf__v_load_bytes) // the first n of uint8_t, converted to float
#define gsf__v_gather GSF__V(gsf__v_gather)         // p[i]
#define gsf__v_madd GSF__V(gsf__v_madd)
#define gsf__v_msub GSF__V(gsf__v_msub)
#define gsf__v_nmadd GSF__V(gsf__v_nmadd)
#define gsf__v_sqrt GSF__V(gsf__v_sqrt)
#define gsf__v_abs GSF__V(gsf__v_abs)
#define gsf__v_with_sign GSF__V(gsf__v_with_sign)   // x, negated where the sign bit of `of` is set
#define gsf__v_min GSF__V(gsf__v_min)
#define gsf__v_max GSF__V(gsf__v_max)
#define gsf__v_round GSF__V(gsf__v_round)           // to the nearest integer, ties to even
#define gsf__v_floor GSF__V(gsf__v_floor)
#define gsf__v_ceil GSF__V(gsf__v_ceil)
#define gsf__v_eq GSF__V(gsf__v_eq)                 // comparisons with a NaN are false
#define gsf__v_lt GSF__V(gsf__v_lt)
#define gsf__v_le GSF__V(gsf__v_le)
#define gsf__v_gt GSF__V(gsf__v_gt)
#define gsf__v_ge GSF__V(gsf__v_ge)
#define gsf__v_select GSF__V(gsf__v_select)         // mask ? yes : no
#define gsf__v_keep GSF__V(gsf__v_keep)             // mask ? x : 0
#define gsf__v_sum GSF__V(gsf__v_sum)
#define gsf__v_largest GSF__V(gsf__v_largest)       // over the lanes, which must not contain a NaN
#define gsf__v_transpose GSF__V(gsf__v_transpose)   // GSF__LANES vectors, as a square matrix, in place
#define gsf__v_pin GSF__V(gsf__v_pin)               // keeps a constant in a register that loops would reload otherwise
#define gsf__v_fetch GSF__V(gsf__v_fetch)           // prefetch
#define gsf__v_bits GSF__V(gsf__v_bits)             // reinterprets the bits as int32_t
#define gsf__v_to_int GSF__V(gsf__v_to_int)         // rounded like gsf__v_round
#define gsf__v_truncate GSF__V(gsf__v_truncate)

#define gsf__vi_set GSF__V(gsf__vi_set)
#define gsf__vi_index GSF__V(gsf__vi_index)         // 0 1 2 ...
#define gsf__vi_load GSF__V(gsf__vi_load)
#define gsf__vi_store GSF__V(gsf__vi_store)
#define gsf__vi_gather GSF__V(gsf__vi_gather)       // p[i]
#define gsf__vi_byte GSF__V(gsf__vi_byte)           // byte k of each lane, 0 the lowest; 0..255
#define gsf__vi_store_pairs GSF__V(gsf__vi_store_pairs) // a[0] b[0] a[1] b[1] ...
#define gsf__vi_add GSF__V(gsf__vi_add)
#define gsf__vi_sub GSF__V(gsf__vi_sub)
#define gsf__vi_mul GSF__V(gsf__vi_mul)
#define gsf__vi_min GSF__V(gsf__vi_min)
#define gsf__vi_shl GSF__V(gsf__vi_shl)             // by the same constant in all lanes
#define gsf__vi_sar GSF__V(gsf__vi_sar)             // arithmetic shift
#define gsf__vi_keep GSF__V(gsf__vi_keep)
#define gsf__vi_floats GSF__V(gsf__vi_floats)       // converts to float
#define gsf__vi_as_floats GSF__V(gsf__vi_as_floats) // reinterprets the bits as float

#define gsf__vm_first GSF__V(gsf__vm_first)         // the first n lanes
#define gsf__vm_of_bits GSF__V(gsf__vm_of_bits)     // lane i is set if bit i is
#define gsf__vm_bits GSF__V(gsf__vm_bits)
#define gsf__vm_and GSF__V(gsf__vm_and)
#define gsf__vm_or GSF__V(gsf__vm_or)
#define gsf__vm_not GSF__V(gsf__vm_not)

#define gsf__vd_set GSF__V(gsf__vd_set)
#define gsf__vd_load GSF__V(gsf__vd_load)           // from floats
#define gsf__vd_read GSF__V(gsf__vd_read)           // from doubles
#define gsf__vd_write GSF__V(gsf__vd_write)         // to doubles
#define gsf__vd_half GSF__V(gsf__vd_half)           // half h < GSF__HALVES of the floats v, converted
#define gsf__vd_floats GSF__V(gsf__vd_floats)       // GSF__HALVES halves, rounded to one gsf__vf
#define gsf__vd_madd GSF__V(gsf__vd_madd)
#define gsf__vd_sqrt GSF__V(gsf__vd_sqrt)
#define gsf__vd_max GSF__V(gsf__vd_max)
#define gsf__vd_keep_above GSF__V(gsf__vd_keep_above) // a > limit ? x : 0
#define gsf__vd_add_folded GSF__V(gsf__vd_add_folded) // sum + (lower + upper half of v, added as floats)
#define gsf__vd_sum GSF__V(gsf__vd_sum)

// Scalar: one lane.

#define GSF__LANES_scalar 1
#define GSF__HALVES_scalar 1
#define GSF__FUSED_scalar 0
#define GSF__V_KERNEL_scalar
#define GSF__V_INLINE_scalar GSF__ALWAYS_INLINE GSF__SHARED inline

typedef float gsf__vf_scalar;
typedef int32_t gsf__vi_scalar;
typedef int gsf__vm_scalar;
typedef double gsf__vd_scalar;

GSF__SHARED inline float gsf__v_set_scalar(float x) { return x; }
GSF__SHARED inline float gsf__v_load_scalar(const float* p) { return *p; }
GSF__SHARED inline void gsf__v_store_scalar(float* p, float x) { *p = x; }
GSF__SHARED inline float gsf__v_load_first_scalar(const float* p, size_t n) { return n ? *p : 0.0f; }
GSF__SHARED inline void gsf__v_store_first_scalar(float* p, float x, size_t n) { if (n) *p = x; }
GSF__SHARED inline float gsf__v_load_bytes_scalar(const uint8_t* p, size_t n) { return n ? (float)*p : 0.0f; }
GSF__SHARED inline float gsf__v_gather_scalar(const float* p, int32_t i) { return p[i]; }
GSF__SHARED inline float gsf__v_madd_scalar(float a, float b, float c) { return a * b + c; }
GSF__SHARED inline float gsf__v_msub_scalar(float a, float b, float c) { return a * b - c; }
GSF__SHARED inline float gsf__v_nmadd_scalar(float a, float b, float c) { return c - a * b; }
GSF__SHARED inline float gsf__v_sqrt_scalar(float x) { return sqrtf(x); }
GSF__SHARED inline float gsf__v_abs_scalar(float x) { return fabsf(x); }
GSF__SHARED inline float gsf__v_with_sign_scalar(float x, float of) { return signbit(of) ? -x : x; }
GSF__SHARED inline float gsf__v_min_scalar(float a, float b) { return a < b ? a : b; }
GSF__SHARED inline float gsf__v_max_scalar(float a, float b) { return a > b ? a : b; }
GSF__SHARED inline float gsf__v_round_scalar(float x) { return rintf(x); }
GSF__SHARED inline float gsf__v_floor_scalar(float x) { return floorf(x); }
GSF__SHARED inline float gsf__v_ceil_scalar(float x) { return ceilf(x); }
GSF__SHARED inline int gsf__v_eq_scalar(float a, float b) { return a == b; }
GSF__SHARED inline int gsf__v_lt_scalar(float a, float b) { return a < b; }
GSF__SHARED inline int gsf__v_le_scalar(float a, float b) { return a <= b; }
GSF__SHARED inline int gsf__v_gt_scalar(float a, float b) { return a > b; }
GSF__SHARED inline int gsf__v_ge_scalar(float a, float b) { return a >= b; }
GSF__SHARED inline float gsf__v_select_scalar(int mask, float yes, float no) { return mask ? yes : no; }
GSF__SHARED inline float gsf__v_keep_scalar(int mask, float x) { return mask ? x : 0.0f; }
GSF__SHARED inline float gsf__v_sum_scalar(float x) { return x; }
GSF__SHARED inline float gsf__v_largest_scalar(float x) { return x; }
GSF__SHARED inline void gsf__v_transpose_scalar(float* m) { (void)m; }
GSF__SHARED inline void gsf__v_pin_scalar(float* v) { (void)v; }
GSF__V_INLINE_scalar void gsf__v_fetch_scalar(const float* p) {
#if defined(__GNUC__) || defined(__clang__)
    __builtin_prefetch(p);
#endif
    (void)p;
}
GSF__SHARED inline int32_t gsf__v_bits_scalar(float x) {
    int32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}
GSF__SHARED inline int32_t gsf__v_to_int_scalar(float x) { return (int32_t)rintf(x); }
GSF__SHARED inline int32_t gsf__v_truncate_scalar(float x) { return (int32_t)x; }

GSF__SHARED inline int32_t gsf__vi_set_scalar(int32_t x) { return x; }
GSF__SHARED inline int32_t gsf__vi_index_scalar(void) { return 0; }
GSF__SHARED inline int32_t gsf__vi_load_scalar(const int32_t* p) { return *p; }
GSF__SHARED inline void gsf__vi_store_scalar(int32_t* p, int32_t x) { *p = x; }
GSF__SHARED inline int32_t gsf__vi_gather_scalar(const uint32_t* p, int32_t i) { return (int32_t)p[i]; }
GSF__SHARED inline int32_t gsf__vi_byte_scalar(int32_t x, int k) { return (int32_t)((uint32_t)x >> 8 * k & 255u); }
GSF__SHARED inline void gsf__vi_store_pairs_scalar(int32_t* p, int32_t a, int32_t b) {
    p[0] = a;
    p[1] = b;
}
GSF__SHARED inline int32_t gsf__vi_add_scalar(int32_t a, int32_t b) { return (int32_t)((uint32_t)a + (uint32_t)b); }
GSF__SHARED inline int32_t gsf__vi_sub_scalar(int32_t a, int32_t b) { return (int32_t)((uint32_t)a - (uint32_t)b); }
GSF__SHARED inline int32_t gsf__vi_mul_scalar(int32_t a, int32_t b) { return (int32_t)((uint32_t)a * (uint32_t)b); }
GSF__SHARED inline int32_t gsf__vi_min_scalar(int32_t a, int32_t b) { return a < b ? a : b; }
GSF__SHARED inline int32_t gsf__vi_shl_scalar(int32_t x, int by) { return (int32_t)((uint32_t)x << by); }
GSF__SHARED inline int32_t gsf__vi_sar_scalar(int32_t x, int by) { return x >> by; }
GSF__SHARED inline int32_t gsf__vi_keep_scalar(int mask, int32_t x) { return mask ? x : 0; }
GSF__SHARED inline float gsf__vi_floats_scalar(int32_t x) { return (float)x; }
GSF__SHARED inline float gsf__vi_as_floats_scalar(int32_t bits) {
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

GSF__SHARED inline int gsf__vm_first_scalar(size_t n) { return n > 0; }
GSF__SHARED inline int gsf__vm_of_bits_scalar(uint32_t bits) { return (int)(bits & 1u); }
GSF__SHARED inline uint32_t gsf__vm_bits_scalar(int mask) { return (uint32_t)mask; }
GSF__SHARED inline int gsf__vm_and_scalar(int a, int b) { return a & b; }
GSF__SHARED inline int gsf__vm_or_scalar(int a, int b) { return a | b; }
GSF__SHARED inline int gsf__vm_not_scalar(int mask) { return !mask; }

GSF__SHARED inline double gsf__vd_set_scalar(double x) { return x; }
GSF__SHARED inline double gsf__vd_load_scalar(const float* p) { return (double)*p; }
GSF__SHARED inline double gsf__vd_read_scalar(const double* p) { return *p; }
GSF__SHARED inline void gsf__vd_write_scalar(double* p, double x) { *p = x; }
GSF__SHARED inline double gsf__vd_half_scalar(float v, int h) { return h ? 0.0 : (double)v; }
GSF__SHARED inline float gsf__vd_floats_scalar(const double* halves) { return (float)*halves; }
GSF__SHARED inline double gsf__vd_madd_scalar(double a, double b, double c) { return a * b + c; }
GSF__SHARED inline double gsf__vd_sqrt_scalar(double x) { return sqrt(x); }
GSF__SHARED inline double gsf__vd_max_scalar(double a, double b) { return a > b ? a : b; }
GSF__SHARED inline double gsf__vd_keep_above_scalar(double a, double limit, double x) { return a > limit ? x : 0.0; }
GSF__SHARED inline double gsf__vd_add_folded_scalar(double sum, float v) { return sum + (double)v; }
GSF__SHARED inline double gsf__vd_sum_scalar(double x) { return x; }

#if GSF__X86

// AVX2: eight lanes.

#define GSF__LANES_avx2 8
#define GSF__HALVES_avx2 2
#define GSF__FUSED_avx2 1
#define GSF__V_KERNEL_avx2 GSF__TARGET_AVX2
#define GSF__V_INLINE_avx2 GSF__INLINE_AVX2

typedef __m256 gsf__vf_avx2;
typedef __m256i gsf__vi_avx2;
typedef __m256 gsf__vm_avx2; // each lane has all bits set or none
typedef __m256d gsf__vd_avx2;

GSF__INLINE_AVX2 __m256i gsf__vi_set_avx2(int32_t x) { return _mm256_set1_epi32(x); }
GSF__INLINE_AVX2 __m256i gsf__vi_index_avx2(void) { return _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7); }
GSF__INLINE_AVX2 __m256i gsf__vi_load_avx2(const int32_t* p) { return _mm256_loadu_si256((const __m256i*)(const void*)p); }
GSF__INLINE_AVX2 void gsf__vi_store_avx2(int32_t* p, __m256i x) { _mm256_storeu_si256((__m256i*)(void*)p, x); }
GSF__INLINE_AVX2 __m256i gsf__vi_gather_avx2(const uint32_t* p, __m256i i) {
    return _mm256_i32gather_epi32((const int*)(const void*)p, i, 4);
}
GSF__INLINE_AVX2 __m256i gsf__vi_byte_avx2(__m256i x, int k) {
    return _mm256_and_si256(_mm256_srli_epi32(x, 8 * k), _mm256_set1_epi32(255));
}
GSF__INLINE_AVX2 void gsf__vi_store_pairs_avx2(int32_t* p, __m256i a, __m256i b) {
    const __m256i low = _mm256_unpacklo_epi32(a, b), high = _mm256_unpackhi_epi32(a, b);
    gsf__vi_store_avx2(p, _mm256_permute2x128_si256(low, high, 0x20));
    gsf__vi_store_avx2(p + 8, _mm256_permute2x128_si256(low, high, 0x31));
}
GSF__INLINE_AVX2 __m256i gsf__vi_add_avx2(__m256i a, __m256i b) { return _mm256_add_epi32(a, b); }
GSF__INLINE_AVX2 __m256i gsf__vi_sub_avx2(__m256i a, __m256i b) { return _mm256_sub_epi32(a, b); }
GSF__INLINE_AVX2 __m256i gsf__vi_mul_avx2(__m256i a, __m256i b) { return _mm256_mullo_epi32(a, b); }
GSF__INLINE_AVX2 __m256i gsf__vi_min_avx2(__m256i a, __m256i b) { return _mm256_min_epi32(a, b); }
GSF__INLINE_AVX2 __m256i gsf__vi_shl_avx2(__m256i x, int by) { return _mm256_slli_epi32(x, by); }
GSF__INLINE_AVX2 __m256i gsf__vi_sar_avx2(__m256i x, int by) { return _mm256_srai_epi32(x, by); }
GSF__INLINE_AVX2 __m256i gsf__vi_keep_avx2(__m256 mask, __m256i x) {
    return _mm256_and_si256(_mm256_castps_si256(mask), x);
}
GSF__INLINE_AVX2 __m256 gsf__vi_floats_avx2(__m256i x) { return _mm256_cvtepi32_ps(x); }
GSF__INLINE_AVX2 __m256 gsf__vi_as_floats_avx2(__m256i bits) { return _mm256_castsi256_ps(bits); }

GSF__INLINE_AVX2 __m256 gsf__vm_first_avx2(size_t n) {
    return _mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_set1_epi32(n < 8 ? (int)n : 8), gsf__vi_index_avx2()));
}
GSF__INLINE_AVX2 __m256 gsf__vm_of_bits_avx2(uint32_t bits) {
    const __m256i bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    return _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32((int)bits), bit), bit));
}
GSF__INLINE_AVX2 uint32_t gsf__vm_bits_avx2(__m256 mask) { return (uint32_t)_mm256_movemask_ps(mask); }
GSF__INLINE_AVX2 __m256 gsf__vm_and_avx2(__m256 a, __m256 b) { return _mm256_and_ps(a, b); }
GSF__INLINE_AVX2 __m256 gsf__vm_or_avx2(__m256 a, __m256 b) { return _mm256_or_ps(a, b); }
GSF__INLINE_AVX2 __m256 gsf__vm_not_avx2(__m256 mask) {
    return _mm256_xor_ps(mask, _mm256_castsi256_ps(_mm256_set1_epi32(-1)));
}

GSF__INLINE_AVX2 __m256 gsf__v_set_avx2(float x) { return _mm256_set1_ps(x); }
GSF__INLINE_AVX2 __m256 gsf__v_load_avx2(const float* p) { return _mm256_loadu_ps(p); }
GSF__INLINE_AVX2 void gsf__v_store_avx2(float* p, __m256 x) { _mm256_storeu_ps(p, x); }
GSF__INLINE_AVX2 __m256 gsf__v_load_first_avx2(const float* p, size_t n) {
    return n >= 8 ? _mm256_loadu_ps(p) : _mm256_maskload_ps(p, _mm256_castps_si256(gsf__vm_first_avx2(n)));
}
// A masked store is several times slower than a full one.
GSF__INLINE_AVX2 void gsf__v_store_first_avx2(float* p, __m256 x, size_t n) {
    if (n >= 8) _mm256_storeu_ps(p, x);
    else _mm256_maskstore_ps(p, _mm256_castps_si256(gsf__vm_first_avx2(n)), x);
}
GSF__INLINE_AVX2 __m256 gsf__v_load_bytes_avx2(const uint8_t* p, size_t n) {
    uint64_t bytes = 0;
    if (n >= 8) memcpy(&bytes, p, 8);
    else memcpy(&bytes, p, n);
    return _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_cvtsi64_si128((long long)bytes)));
}
GSF__INLINE_AVX2 __m256 gsf__v_gather_avx2(const float* p, __m256i i) { return _mm256_i32gather_ps(p, i, 4); }
GSF__INLINE_AVX2 __m256 gsf__v_madd_avx2(__m256 a, __m256 b, __m256 c) { return _mm256_fmadd_ps(a, b, c); }
GSF__INLINE_AVX2 __m256 gsf__v_msub_avx2(__m256 a, __m256 b, __m256 c) { return _mm256_fmsub_ps(a, b, c); }
GSF__INLINE_AVX2 __m256 gsf__v_nmadd_avx2(__m256 a, __m256 b, __m256 c) { return _mm256_fnmadd_ps(a, b, c); }
GSF__INLINE_AVX2 __m256 gsf__v_sqrt_avx2(__m256 x) { return _mm256_sqrt_ps(x); }
GSF__INLINE_AVX2 __m256 gsf__v_abs_avx2(__m256 x) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), x); }
GSF__INLINE_AVX2 __m256 gsf__v_with_sign_avx2(__m256 x, __m256 of) {
    return _mm256_xor_ps(x, _mm256_and_ps(of, _mm256_set1_ps(-0.0f)));
}
GSF__INLINE_AVX2 __m256 gsf__v_min_avx2(__m256 a, __m256 b) { return _mm256_min_ps(a, b); }
GSF__INLINE_AVX2 __m256 gsf__v_max_avx2(__m256 a, __m256 b) { return _mm256_max_ps(a, b); }
GSF__INLINE_AVX2 __m256 gsf__v_round_avx2(__m256 x) {
    return _mm256_round_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
}
GSF__INLINE_AVX2 __m256 gsf__v_floor_avx2(__m256 x) { return _mm256_floor_ps(x); }
GSF__INLINE_AVX2 __m256 gsf__v_ceil_avx2(__m256 x) { return _mm256_ceil_ps(x); }
GSF__INLINE_AVX2 __m256 gsf__v_eq_avx2(__m256 a, __m256 b) { return _mm256_cmp_ps(a, b, _CMP_EQ_OQ); }
GSF__INLINE_AVX2 __m256 gsf__v_lt_avx2(__m256 a, __m256 b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }
GSF__INLINE_AVX2 __m256 gsf__v_le_avx2(__m256 a, __m256 b) { return _mm256_cmp_ps(a, b, _CMP_LE_OQ); }
GSF__INLINE_AVX2 __m256 gsf__v_gt_avx2(__m256 a, __m256 b) { return _mm256_cmp_ps(a, b, _CMP_GT_OQ); }
GSF__INLINE_AVX2 __m256 gsf__v_ge_avx2(__m256 a, __m256 b) { return _mm256_cmp_ps(a, b, _CMP_GE_OQ); }
GSF__INLINE_AVX2 __m256 gsf__v_select_avx2(__m256 mask, __m256 yes, __m256 no) { return _mm256_blendv_ps(no, yes, mask); }
GSF__INLINE_AVX2 __m256 gsf__v_keep_avx2(__m256 mask, __m256 x) { return _mm256_and_ps(mask, x); }
GSF__INLINE_AVX2 float gsf__v_sum_avx2(__m256 v) {
    __m128 s = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    s = _mm_add_ps(s, _mm_movehl_ps(s, s));
    return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}
GSF__INLINE_AVX2 float gsf__v_largest_avx2(__m256 v) {
    __m128 s = _mm_max_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    s = _mm_max_ps(s, _mm_movehl_ps(s, s));
    return _mm_cvtss_f32(_mm_max_ss(s, _mm_movehdup_ps(s)));
}
GSF__INLINE_AVX2 void gsf__v_transpose_avx2(__m256 m[8]) {
    const __m256 a0 = _mm256_unpacklo_ps(m[0], m[1]), a1 = _mm256_unpackhi_ps(m[0], m[1]);
    const __m256 a2 = _mm256_unpacklo_ps(m[2], m[3]), a3 = _mm256_unpackhi_ps(m[2], m[3]);
    const __m256 a4 = _mm256_unpacklo_ps(m[4], m[5]), a5 = _mm256_unpackhi_ps(m[4], m[5]);
    const __m256 a6 = _mm256_unpacklo_ps(m[6], m[7]), a7 = _mm256_unpackhi_ps(m[6], m[7]);
    const __m256 b0 = _mm256_shuffle_ps(a0, a2, 0x44), b4 = _mm256_shuffle_ps(a4, a6, 0x44);
    const __m256 b1 = _mm256_shuffle_ps(a0, a2, 0xee), b5 = _mm256_shuffle_ps(a4, a6, 0xee);
    const __m256 b2 = _mm256_shuffle_ps(a1, a3, 0x44), b6 = _mm256_shuffle_ps(a5, a7, 0x44);
    const __m256 b3 = _mm256_shuffle_ps(a1, a3, 0xee), b7 = _mm256_shuffle_ps(a5, a7, 0xee);
    m[0] = _mm256_permute2f128_ps(b0, b4, 0x20);
    m[1] = _mm256_permute2f128_ps(b1, b5, 0x20);
    m[2] = _mm256_permute2f128_ps(b2, b6, 0x20);
    m[3] = _mm256_permute2f128_ps(b3, b7, 0x20);
    m[4] = _mm256_permute2f128_ps(b0, b4, 0x31);
    m[5] = _mm256_permute2f128_ps(b1, b5, 0x31);
    m[6] = _mm256_permute2f128_ps(b2, b6, 0x31);
    m[7] = _mm256_permute2f128_ps(b3, b7, 0x31);
}
GSF__INLINE_AVX2 void gsf__v_pin_avx2(__m256* v) { __asm__("" : "+x"(*v)); }
GSF__INLINE_AVX2 void gsf__v_fetch_avx2(const float* p) { _mm_prefetch((const char*)p, _MM_HINT_T0); }
GSF__INLINE_AVX2 __m256i gsf__v_bits_avx2(__m256 x) { return _mm256_castps_si256(x); }
GSF__INLINE_AVX2 __m256i gsf__v_to_int_avx2(__m256 x) { return _mm256_cvtps_epi32(x); }
GSF__INLINE_AVX2 __m256i gsf__v_truncate_avx2(__m256 x) { return _mm256_cvttps_epi32(x); }

GSF__INLINE_AVX2 __m256d gsf__vd_set_avx2(double x) { return _mm256_set1_pd(x); }
GSF__INLINE_AVX2 __m256d gsf__vd_load_avx2(const float* p) { return _mm256_cvtps_pd(_mm_loadu_ps(p)); }
GSF__INLINE_AVX2 __m256d gsf__vd_read_avx2(const double* p) { return _mm256_loadu_pd(p); }
GSF__INLINE_AVX2 void gsf__vd_write_avx2(double* p, __m256d x) { _mm256_storeu_pd(p, x); }
GSF__INLINE_AVX2 __m256d gsf__vd_half_avx2(__m256 v, int h) {
    return _mm256_cvtps_pd(h ? _mm256_extractf128_ps(v, 1) : _mm256_castps256_ps128(v));
}
GSF__INLINE_AVX2 __m256 gsf__vd_floats_avx2(const __m256d halves[2]) {
    return _mm256_set_m128(_mm256_cvtpd_ps(halves[1]), _mm256_cvtpd_ps(halves[0]));
}
GSF__INLINE_AVX2 __m256d gsf__vd_madd_avx2(__m256d a, __m256d b, __m256d c) { return _mm256_fmadd_pd(a, b, c); }
GSF__INLINE_AVX2 __m256d gsf__vd_sqrt_avx2(__m256d x) { return _mm256_sqrt_pd(x); }
GSF__INLINE_AVX2 __m256d gsf__vd_max_avx2(__m256d a, __m256d b) { return _mm256_max_pd(a, b); }
GSF__INLINE_AVX2 __m256d gsf__vd_keep_above_avx2(__m256d a, __m256d limit, __m256d x) {
    return _mm256_and_pd(x, _mm256_cmp_pd(a, limit, _CMP_GT_OQ));
}
GSF__INLINE_AVX2 __m256d gsf__vd_add_folded_avx2(__m256d sum, __m256 v) {
    const __m128 pairs = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    return _mm256_add_pd(sum, _mm256_cvtps_pd(pairs));
}
GSF__INLINE_AVX2 double gsf__vd_sum_avx2(__m256d v) {
    const __m128d s = _mm_add_pd(_mm256_castpd256_pd128(v), _mm256_extractf128_pd(v, 1));
    return _mm_cvtsd_f64(_mm_add_sd(s, _mm_unpackhi_pd(s, s)));
}

// AVX-512: sixteen lanes.

#define GSF__LANES_avx512 16
#define GSF__HALVES_avx512 2
#define GSF__FUSED_avx512 1
#define GSF__V_KERNEL_avx512 GSF__TARGET_AVX512
#define GSF__V_INLINE_avx512 GSF__INLINE_AVX512

typedef __m512 gsf__vf_avx512;
typedef __m512i gsf__vi_avx512;
typedef __mmask16 gsf__vm_avx512;
typedef __m512d gsf__vd_avx512;

GSF__INLINE_AVX512 __m512i gsf__vi_set_avx512(int32_t x) { return _mm512_set1_epi32(x); }
GSF__INLINE_AVX512 __m512i gsf__vi_index_avx512(void) {
    return _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
GSF__INLINE_AVX512 __m512i gsf__vi_load_avx512(const int32_t* p) { return _mm512_loadu_si512(p); }
GSF__INLINE_AVX512 void gsf__vi_store_avx512(int32_t* p, __m512i x) { _mm512_storeu_si512(p, x); }
GSF__INLINE_AVX512 __m512i gsf__vi_byte_avx512(__m512i x, int k) {
    return _mm512_and_si512(_mm512_srli_epi32(x, (unsigned)(8 * k)), _mm512_set1_epi32(255));
}
GSF__INLINE_AVX512 void gsf__vi_store_pairs_avx512(int32_t* p, __m512i a, __m512i b) {
    const __m512i first = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    const __m512i second = _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    gsf__vi_store_avx512(p, _mm512_permutex2var_epi32(a, first, b));
    gsf__vi_store_avx512(p + 16, _mm512_permutex2var_epi32(a, second, b));
}
GSF__INLINE_AVX512 __m512i gsf__vi_add_avx512(__m512i a, __m512i b) { return _mm512_add_epi32(a, b); }
GSF__INLINE_AVX512 __m512i gsf__vi_sub_avx512(__m512i a, __m512i b) { return _mm512_sub_epi32(a, b); }
GSF__INLINE_AVX512 __m512i gsf__vi_mul_avx512(__m512i a, __m512i b) { return _mm512_mullo_epi32(a, b); }
GSF__INLINE_AVX512 __m512i gsf__vi_min_avx512(__m512i a, __m512i b) { return _mm512_min_epi32(a, b); }
GSF__INLINE_AVX512 __m512i gsf__vi_shl_avx512(__m512i x, int by) { return _mm512_slli_epi32(x, (unsigned)by); }
GSF__INLINE_AVX512 __m512i gsf__vi_sar_avx512(__m512i x, int by) { return _mm512_srai_epi32(x, (unsigned)by); }
GSF__INLINE_AVX512 __m512i gsf__vi_keep_avx512(__mmask16 mask, __m512i x) { return _mm512_maskz_mov_epi32(mask, x); }
GSF__INLINE_AVX512 __m512 gsf__vi_floats_avx512(__m512i x) { return _mm512_cvtepi32_ps(x); }
GSF__INLINE_AVX512 __m512 gsf__vi_as_floats_avx512(__m512i bits) { return _mm512_castsi512_ps(bits); }

GSF__INLINE_AVX512 __mmask16 gsf__vm_first_avx512(size_t n) { return (__mmask16)(n < 16 ? (1u << n) - 1u : 0xffffu); }
GSF__INLINE_AVX512 __mmask16 gsf__vm_of_bits_avx512(uint32_t bits) { return (__mmask16)bits; }
GSF__INLINE_AVX512 uint32_t gsf__vm_bits_avx512(__mmask16 mask) { return mask; }
GSF__INLINE_AVX512 __mmask16 gsf__vm_and_avx512(__mmask16 a, __mmask16 b) { return (__mmask16)(a & b); }
GSF__INLINE_AVX512 __mmask16 gsf__vm_or_avx512(__mmask16 a, __mmask16 b) { return (__mmask16)(a | b); }
GSF__INLINE_AVX512 __mmask16 gsf__vm_not_avx512(__mmask16 mask) { return (__mmask16)~mask; }

GSF__INLINE_AVX512 __m512 gsf__v_set_avx512(float x) { return _mm512_set1_ps(x); }
GSF__INLINE_AVX512 __m512 gsf__v_load_avx512(const float* p) { return _mm512_loadu_ps(p); }
GSF__INLINE_AVX512 void gsf__v_store_avx512(float* p, __m512 x) { _mm512_storeu_ps(p, x); }
GSF__INLINE_AVX512 __m512 gsf__v_load_first_avx512(const float* p, size_t n) {
    return n >= 16 ? _mm512_loadu_ps(p) : _mm512_maskz_loadu_ps(gsf__vm_first_avx512(n), p);
}
GSF__INLINE_AVX512 void gsf__v_store_first_avx512(float* p, __m512 x, size_t n) {
    if (n >= 16) _mm512_storeu_ps(p, x);
    else _mm512_mask_storeu_ps(p, gsf__vm_first_avx512(n), x);
}
GSF__INLINE_AVX512 __m512 gsf__v_load_bytes_avx512(const uint8_t* p, size_t n) {
    return _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_maskz_loadu_epi8(gsf__vm_first_avx512(n), p)));
}
GSF__INLINE_AVX512 __m512 gsf__v_madd_avx512(__m512 a, __m512 b, __m512 c) { return _mm512_fmadd_ps(a, b, c); }
GSF__INLINE_AVX512 __m512 gsf__v_msub_avx512(__m512 a, __m512 b, __m512 c) { return _mm512_fmsub_ps(a, b, c); }
GSF__INLINE_AVX512 __m512 gsf__v_nmadd_avx512(__m512 a, __m512 b, __m512 c) { return _mm512_fnmadd_ps(a, b, c); }
GSF__INLINE_AVX512 __m512 gsf__v_sqrt_avx512(__m512 x) { return _mm512_sqrt_ps(x); }
GSF__INLINE_AVX512 __m512 gsf__v_abs_avx512(__m512 x) { return _mm512_abs_ps(x); }
GSF__INLINE_AVX512 __m512 gsf__v_with_sign_avx512(__m512 x, __m512 of) {
    return _mm512_xor_ps(x, _mm512_and_ps(of, _mm512_set1_ps(-0.0f)));
}
GSF__INLINE_AVX512 __m512 gsf__v_min_avx512(__m512 a, __m512 b) { return _mm512_min_ps(a, b); }
GSF__INLINE_AVX512 __m512 gsf__v_max_avx512(__m512 a, __m512 b) { return _mm512_max_ps(a, b); }
GSF__INLINE_AVX512 __mmask16 gsf__v_eq_avx512(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_EQ_OQ); }
GSF__INLINE_AVX512 __mmask16 gsf__v_lt_avx512(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
GSF__INLINE_AVX512 __mmask16 gsf__v_le_avx512(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
GSF__INLINE_AVX512 __mmask16 gsf__v_gt_avx512(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
GSF__INLINE_AVX512 __mmask16 gsf__v_ge_avx512(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
GSF__INLINE_AVX512 __m512 gsf__v_select_avx512(__mmask16 mask, __m512 yes, __m512 no) {
    return _mm512_mask_blend_ps(mask, no, yes);
}
GSF__INLINE_AVX512 __m512 gsf__v_keep_avx512(__mmask16 mask, __m512 x) { return _mm512_maskz_mov_ps(mask, x); }
GSF__INLINE_AVX512 __m256 gsf__v_upper_avx512(__m512 v) { return _mm512_extractf32x8_ps(v, 1); }
GSF__INLINE_AVX512 float gsf__v_sum_avx512(__m512 v) {
    return gsf__v_sum_avx2(_mm256_add_ps(_mm512_castps512_ps256(v), gsf__v_upper_avx512(v)));
}
GSF__INLINE_AVX512 float gsf__v_largest_avx512(__m512 v) {
    return gsf__v_largest_avx2(_mm256_max_ps(_mm512_castps512_ps256(v), gsf__v_upper_avx512(v)));
}
// Transposes the four 8 x 8 quarters and swaps the off-diagonal ones.
GSF__INLINE_AVX512 void gsf__v_transpose_avx512(__m512 m[16]) {
    __m256 quarter[4][8];
    for (int i = 0; i < 8; i++) {
        quarter[0][i] = _mm512_castps512_ps256(m[i]);
        quarter[1][i] = gsf__v_upper_avx512(m[i]);
        quarter[2][i] = _mm512_castps512_ps256(m[8 + i]);
        quarter[3][i] = gsf__v_upper_avx512(m[8 + i]);
    }
    for (int q = 0; q < 4; q++) gsf__v_transpose_avx2(quarter[q]);
    for (int i = 0; i < 8; i++) {
        m[i] = _mm512_insertf32x8(_mm512_castps256_ps512(quarter[0][i]), quarter[2][i], 1);
        m[8 + i] = _mm512_insertf32x8(_mm512_castps256_ps512(quarter[1][i]), quarter[3][i], 1);
    }
}
#if !defined(__clang__) // without optimisation, these intrinsics are macros in GCC's headers and trigger this warning
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wsign-conversion"
#endif
GSF__INLINE_AVX512 __m512 gsf__v_gather_avx512(const float* p, __m512i i) { return _mm512_i32gather_ps(i, p, 4); }
GSF__INLINE_AVX512 __m512i gsf__vi_gather_avx512(const uint32_t* p, __m512i i) {
    return _mm512_castps_si512(gsf__v_gather_avx512((const float*)(const void*)p, i));
}
GSF__INLINE_AVX512 __m512 gsf__v_round_avx512(__m512 x) {
    return _mm512_roundscale_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
}
GSF__INLINE_AVX512 __m512 gsf__v_floor_avx512(__m512 x) {
    return _mm512_roundscale_ps(x, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
}
GSF__INLINE_AVX512 __m512 gsf__v_scale2_avx512(__m512 x, __m512 k) { return _mm512_scalef_ps(x, k); } // x 2^k
GSF__INLINE_AVX512 __m512 gsf__v_ceil_avx512(__m512 x) {
    return _mm512_roundscale_ps(x, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC);
}
#if !defined(__clang__)
#pragma GCC diagnostic pop
#endif
GSF__INLINE_AVX512 void gsf__v_pin_avx512(__m512* v) { __asm__("" : "+v"(*v)); }
GSF__INLINE_AVX512 void gsf__v_fetch_avx512(const float* p) { _mm_prefetch((const char*)p, _MM_HINT_T0); }
GSF__INLINE_AVX512 __m512i gsf__v_bits_avx512(__m512 x) { return _mm512_castps_si512(x); }
GSF__INLINE_AVX512 __m512i gsf__v_to_int_avx512(__m512 x) { return _mm512_cvtps_epi32(x); }
GSF__INLINE_AVX512 __m512i gsf__v_truncate_avx512(__m512 x) { return _mm512_cvttps_epi32(x); }

GSF__INLINE_AVX512 __m512d gsf__vd_set_avx512(double x) { return _mm512_set1_pd(x); }
GSF__INLINE_AVX512 __m512d gsf__vd_load_avx512(const float* p) { return _mm512_cvtps_pd(_mm256_loadu_ps(p)); }
GSF__INLINE_AVX512 __m512d gsf__vd_read_avx512(const double* p) { return _mm512_loadu_pd(p); }
GSF__INLINE_AVX512 void gsf__vd_write_avx512(double* p, __m512d x) { _mm512_storeu_pd(p, x); }
GSF__INLINE_AVX512 __m512d gsf__vd_half_avx512(__m512 v, int h) {
    return _mm512_cvtps_pd(h ? gsf__v_upper_avx512(v) : _mm512_castps512_ps256(v));
}
GSF__INLINE_AVX512 __m512 gsf__vd_floats_avx512(const __m512d halves[2]) {
    return _mm512_insertf32x8(_mm512_castps256_ps512(_mm512_cvtpd_ps(halves[0])), _mm512_cvtpd_ps(halves[1]), 1);
}
GSF__INLINE_AVX512 __m512d gsf__vd_madd_avx512(__m512d a, __m512d b, __m512d c) { return _mm512_fmadd_pd(a, b, c); }
GSF__INLINE_AVX512 __m512d gsf__vd_sqrt_avx512(__m512d x) { return _mm512_sqrt_pd(x); }
GSF__INLINE_AVX512 __m512d gsf__vd_max_avx512(__m512d a, __m512d b) { return _mm512_max_pd(a, b); }
GSF__INLINE_AVX512 __m512d gsf__vd_keep_above_avx512(__m512d a, __m512d limit, __m512d x) {
    return _mm512_maskz_mov_pd(_mm512_cmp_pd_mask(a, limit, _CMP_GT_OQ), x);
}
GSF__INLINE_AVX512 __m512d gsf__vd_add_folded_avx512(__m512d sum, __m512 v) {
    return _mm512_add_pd(sum, _mm512_cvtps_pd(_mm256_add_ps(_mm512_castps512_ps256(v), gsf__v_upper_avx512(v))));
}
GSF__INLINE_AVX512 double gsf__vd_sum_avx512(__m512d v) {
    return gsf__vd_sum_avx2(_mm256_add_pd(_mm512_castpd512_pd256(v), _mm512_extractf64x4_pd(v, 1)));
}

#endif // GSF__X86

#if GSF__SIMD128

// Four lanes, in terms of GCC's and Clang's vectors where their operators do the same on all processors.

#define GSF__LANES_simd128 4
#define GSF__HALVES_simd128 2
#define GSF__FUSED_simd128 GSF__NEON
#define GSF__V_KERNEL_simd128
#define GSF__V_INLINE_simd128 GSF__ALWAYS_INLINE GSF__SHARED inline
#define GSF__INLINE_SIMD128 GSF__V_INLINE_simd128

#if GSF__NEON
typedef float32x4_t gsf__vf_simd128;
typedef int32x4_t gsf__vi_simd128;
typedef float64x2_t gsf__vd_simd128;
#else
typedef float gsf__vf_simd128 __attribute__((vector_size(16)));
typedef int32_t gsf__vi_simd128 __attribute__((vector_size(16)));
typedef double gsf__vd_simd128 __attribute__((vector_size(16)));
#endif
typedef gsf__vi_simd128 gsf__vm_simd128; // each lane has all bits set or none
typedef uint32_t gsf__vu_simd128 __attribute__((vector_size(16)));

GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_set_simd128(int32_t x) {
    const gsf__vi_simd128 v = {x, x, x, x};
    return v;
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_index_simd128(void) {
    const gsf__vi_simd128 v = {0, 1, 2, 3};
    return v;
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_load_simd128(const int32_t* p) {
    gsf__vi_simd128 v;
    memcpy(&v, p, sizeof v);
    return v;
}
GSF__INLINE_SIMD128 void gsf__vi_store_simd128(int32_t* p, gsf__vi_simd128 x) { memcpy(p, &x, sizeof x); }
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_gather_simd128(const uint32_t* p, gsf__vi_simd128 i) {
    const gsf__vi_simd128 v = {(int32_t)p[i[0]], (int32_t)p[i[1]], (int32_t)p[i[2]], (int32_t)p[i[3]]};
    return v;
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_byte_simd128(gsf__vi_simd128 x, int k) {
    return (gsf__vi_simd128)((gsf__vu_simd128)x >> (uint32_t)(8 * k) & 255u);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_add_simd128(gsf__vi_simd128 a, gsf__vi_simd128 b) {
    return (gsf__vi_simd128)((gsf__vu_simd128)a + (gsf__vu_simd128)b);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_sub_simd128(gsf__vi_simd128 a, gsf__vi_simd128 b) {
    return (gsf__vi_simd128)((gsf__vu_simd128)a - (gsf__vu_simd128)b);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_mul_simd128(gsf__vi_simd128 a, gsf__vi_simd128 b) {
    return (gsf__vi_simd128)((gsf__vu_simd128)a * (gsf__vu_simd128)b);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_shl_simd128(gsf__vi_simd128 x, int by) {
    return (gsf__vi_simd128)((gsf__vu_simd128)x << (uint32_t)by);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_sar_simd128(gsf__vi_simd128 x, int by) { return x >> by; }
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_keep_simd128(gsf__vm_simd128 mask, gsf__vi_simd128 x) { return mask & x; }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__vi_as_floats_simd128(gsf__vi_simd128 bits) { return (gsf__vf_simd128)bits; }
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__v_bits_simd128(gsf__vf_simd128 x) { return (gsf__vi_simd128)x; }

GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__vm_first_simd128(size_t n) {
    return (gsf__vm_simd128)(gsf__vi_index_simd128() < gsf__vi_set_simd128(n < 4 ? (int32_t)n : 4));
}
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__vm_of_bits_simd128(uint32_t bits) {
    const gsf__vi_simd128 bit = {1, 2, 4, 8};
    return (gsf__vm_simd128)((gsf__vi_set_simd128((int32_t)bits) & bit) == bit);
}
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__vm_and_simd128(gsf__vm_simd128 a, gsf__vm_simd128 b) { return a & b; }
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__vm_or_simd128(gsf__vm_simd128 a, gsf__vm_simd128 b) { return a | b; }
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__vm_not_simd128(gsf__vm_simd128 mask) { return ~mask; }

GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_set_simd128(float x) {
    const gsf__vf_simd128 v = {x, x, x, x};
    return v;
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_load_simd128(const float* p) {
    gsf__vf_simd128 v;
    memcpy(&v, p, sizeof v);
    return v;
}
GSF__INLINE_SIMD128 void gsf__v_store_simd128(float* p, gsf__vf_simd128 x) { memcpy(p, &x, sizeof x); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_load_first_simd128(const float* p, size_t n) {
    if (n >= 4) return gsf__v_load_simd128(p);
    const gsf__vf_simd128 v = {n > 0 ? p[0] : 0.0f, n > 1 ? p[1] : 0.0f, n > 2 ? p[2] : 0.0f, 0.0f};
    return v;
}
GSF__INLINE_SIMD128 void gsf__v_store_first_simd128(float* p, gsf__vf_simd128 x, size_t n) {
    if (n >= 4) {
        gsf__v_store_simd128(p, x);
        return;
    }
    if (n > 0) p[0] = x[0];
    if (n > 1) p[1] = x[1];
    if (n > 2) p[2] = x[2];
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_gather_simd128(const float* p, gsf__vi_simd128 i) {
    const gsf__vf_simd128 v = {p[i[0]], p[i[1]], p[i[2]], p[i[3]]};
    return v;
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_load_bytes_simd128(const uint8_t* p, size_t n) {
    const gsf__vf_simd128 v = {n > 0 ? (float)p[0] : 0.0f, n > 1 ? (float)p[1] : 0.0f, n > 2 ? (float)p[2] : 0.0f,
                               n > 3 ? (float)p[3] : 0.0f};
    return v;
}
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__v_eq_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return (gsf__vm_simd128)(a == b);
}
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__v_lt_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return (gsf__vm_simd128)(a < b); }
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__v_le_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return (gsf__vm_simd128)(a <= b);
}
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__v_gt_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return (gsf__vm_simd128)(a > b); }
GSF__INLINE_SIMD128 gsf__vm_simd128 gsf__v_ge_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return (gsf__vm_simd128)(a >= b);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_keep_simd128(gsf__vm_simd128 mask, gsf__vf_simd128 x) {
    return (gsf__vf_simd128)(mask & (gsf__vi_simd128)x);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_abs_simd128(gsf__vf_simd128 x) {
    return gsf__v_keep_simd128(gsf__vi_set_simd128(0x7fffffff), x);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_with_sign_simd128(gsf__vf_simd128 x, gsf__vf_simd128 of) {
    return (gsf__vf_simd128)((gsf__vi_simd128)x ^ ((gsf__vi_simd128)of & gsf__vi_set_simd128(-0x7fffffff - 1)));
}
GSF__INLINE_SIMD128 void gsf__v_pin_simd128(gsf__vf_simd128* v) { (void)v; }
GSF__INLINE_SIMD128 void gsf__v_fetch_simd128(const float* p) { __builtin_prefetch(p); }
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_set_simd128(double x) {
    const gsf__vd_simd128 v = {x, x};
    return v;
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_read_simd128(const double* p) {
    gsf__vd_simd128 v;
    memcpy(&v, p, sizeof v);
    return v;
}
GSF__INLINE_SIMD128 void gsf__vd_write_simd128(double* p, gsf__vd_simd128 x) { memcpy(p, &x, sizeof x); }
GSF__INLINE_SIMD128 double gsf__vd_sum_simd128(gsf__vd_simd128 x) { return x[0] + x[1]; }
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_load_simd128(const float* p) {
    const gsf__vd_simd128 v = {(double)p[0], (double)p[1]};
    return v;
}

#if GSF__NEON

GSF__INLINE_SIMD128 uint32_t gsf__vm_bits_simd128(gsf__vm_simd128 mask) {
    const uint32x4_t bit = {1, 2, 4, 8};
    return vaddvq_u32(vandq_u32(vreinterpretq_u32_s32(mask), bit));
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_madd_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b, gsf__vf_simd128 c) {
    return vfmaq_f32(c, a, b);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_msub_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b, gsf__vf_simd128 c) {
    return vfmaq_f32(vnegq_f32(c), a, b);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_nmadd_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b, gsf__vf_simd128 c) {
    return vfmsq_f32(c, a, b);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_select_simd128(gsf__vm_simd128 mask, gsf__vf_simd128 yes, gsf__vf_simd128 no) {
    return vbslq_f32(vreinterpretq_u32_s32(mask), yes, no);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_min_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return vbslq_f32(vcltq_f32(a, b), a, b); // Arm's own minimum propagates a NaN in either operand
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_max_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return vbslq_f32(vcgtq_f32(a, b), a, b);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_sqrt_simd128(gsf__vf_simd128 x) { return vsqrtq_f32(x); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_round_simd128(gsf__vf_simd128 x) { return vrndnq_f32(x); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_floor_simd128(gsf__vf_simd128 x) { return vrndmq_f32(x); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_ceil_simd128(gsf__vf_simd128 x) { return vrndpq_f32(x); }
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__v_to_int_simd128(gsf__vf_simd128 x) { return vcvtnq_s32_f32(x); }
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__v_truncate_simd128(gsf__vf_simd128 x) { return vcvtq_s32_f32(x); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__vi_floats_simd128(gsf__vi_simd128 x) { return vcvtq_f32_s32(x); }
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_min_simd128(gsf__vi_simd128 a, gsf__vi_simd128 b) { return vminq_s32(a, b); }
GSF__INLINE_SIMD128 float gsf__v_sum_simd128(gsf__vf_simd128 v) {
    return vaddv_f32(vadd_f32(vget_low_f32(v), vget_high_f32(v)));
}
GSF__INLINE_SIMD128 float gsf__v_largest_simd128(gsf__vf_simd128 v) { return vmaxvq_f32(v); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_mix_low_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return vzip1q_f32(a, b); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_mix_high_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return vzip2q_f32(a, b); }
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_half_simd128(gsf__vf_simd128 v, int h) {
    return h ? vcvt_high_f64_f32(v) : vcvt_f64_f32(vget_low_f32(v));
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__vd_floats_simd128(const gsf__vd_simd128 halves[2]) {
    return vcvt_high_f32_f64(vcvt_f32_f64(halves[0]), halves[1]);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_madd_simd128(gsf__vd_simd128 a, gsf__vd_simd128 b, gsf__vd_simd128 c) {
    return vfmaq_f64(c, a, b);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_sqrt_simd128(gsf__vd_simd128 x) { return vsqrtq_f64(x); }
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_max_simd128(gsf__vd_simd128 a, gsf__vd_simd128 b) {
    return vbslq_f64(vcgtq_f64(a, b), a, b);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_keep_above_simd128(gsf__vd_simd128 a, gsf__vd_simd128 limit, gsf__vd_simd128 x) {
    return vbslq_f64(vcgtq_f64(a, limit), x, gsf__vd_set_simd128(0.0));
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_add_folded_simd128(gsf__vd_simd128 sum, gsf__vf_simd128 v) {
    return sum + vcvt_f64_f32(vadd_f32(vget_low_f32(v), vget_high_f32(v)));
}

#else // WebAssembly

GSF__INLINE_SIMD128 uint32_t gsf__vm_bits_simd128(gsf__vm_simd128 mask) { return (uint32_t)wasm_i32x4_bitmask((v128_t)mask); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_madd_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b, gsf__vf_simd128 c) {
    return a * b + c;
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_msub_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b, gsf__vf_simd128 c) {
    return a * b - c;
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_nmadd_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b, gsf__vf_simd128 c) {
    return c - a * b;
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_select_simd128(gsf__vm_simd128 mask, gsf__vf_simd128 yes, gsf__vf_simd128 no) {
    return (gsf__vf_simd128)wasm_v128_bitselect((v128_t)yes, (v128_t)no, (v128_t)mask);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_min_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return (gsf__vf_simd128)wasm_f32x4_pmin((v128_t)b, (v128_t)a); // a < b ? a : b
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_max_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return (gsf__vf_simd128)wasm_f32x4_pmax((v128_t)b, (v128_t)a); // b < a ? a : b
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_sqrt_simd128(gsf__vf_simd128 x) {
    return (gsf__vf_simd128)wasm_f32x4_sqrt((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_round_simd128(gsf__vf_simd128 x) {
    return (gsf__vf_simd128)wasm_f32x4_nearest((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_floor_simd128(gsf__vf_simd128 x) {
    return (gsf__vf_simd128)wasm_f32x4_floor((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_ceil_simd128(gsf__vf_simd128 x) {
    return (gsf__vf_simd128)wasm_f32x4_ceil((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__v_truncate_simd128(gsf__vf_simd128 x) {
    return (gsf__vi_simd128)wasm_i32x4_trunc_sat_f32x4((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__v_to_int_simd128(gsf__vf_simd128 x) {
    return gsf__v_truncate_simd128(gsf__v_round_simd128(x));
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__vi_floats_simd128(gsf__vi_simd128 x) {
    return (gsf__vf_simd128)wasm_f32x4_convert_i32x4((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vi_simd128 gsf__vi_min_simd128(gsf__vi_simd128 a, gsf__vi_simd128 b) {
    return (gsf__vi_simd128)wasm_i32x4_min((v128_t)a, (v128_t)b);
}
GSF__INLINE_SIMD128 float gsf__v_sum_simd128(gsf__vf_simd128 v) { return (v[0] + v[2]) + (v[1] + v[3]); }
GSF__INLINE_SIMD128 float gsf__v_largest_simd128(gsf__vf_simd128 v) {
    const float a = v[0] > v[2] ? v[0] : v[2], b = v[1] > v[3] ? v[1] : v[3];
    return a > b ? a : b;
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_mix_low_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return __builtin_shufflevector(a, b, 0, 4, 1, 5);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__v_mix_high_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return __builtin_shufflevector(a, b, 2, 6, 3, 7);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_half_simd128(gsf__vf_simd128 v, int h) {
    const gsf__vf_simd128 half = h ? __builtin_shufflevector(v, v, 2, 3, 2, 3) : v;
    return (gsf__vd_simd128)wasm_f64x2_promote_low_f32x4((v128_t)half);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__vd_floats_simd128(const gsf__vd_simd128 halves[2]) {
    const gsf__vf_simd128 low = (gsf__vf_simd128)wasm_f32x4_demote_f64x2_zero((v128_t)halves[0]);
    const gsf__vf_simd128 high = (gsf__vf_simd128)wasm_f32x4_demote_f64x2_zero((v128_t)halves[1]);
    return __builtin_shufflevector(low, high, 0, 1, 4, 5);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_madd_simd128(gsf__vd_simd128 a, gsf__vd_simd128 b, gsf__vd_simd128 c) {
    return a * b + c;
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_sqrt_simd128(gsf__vd_simd128 x) {
    return (gsf__vd_simd128)wasm_f64x2_sqrt((v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_max_simd128(gsf__vd_simd128 a, gsf__vd_simd128 b) {
    return (gsf__vd_simd128)wasm_f64x2_pmax((v128_t)b, (v128_t)a);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_keep_above_simd128(gsf__vd_simd128 a, gsf__vd_simd128 limit, gsf__vd_simd128 x) {
    return (gsf__vd_simd128)wasm_v128_and(wasm_f64x2_gt((v128_t)a, (v128_t)limit), (v128_t)x);
}
GSF__INLINE_SIMD128 gsf__vd_simd128 gsf__vd_add_folded_simd128(gsf__vd_simd128 sum, gsf__vf_simd128 v) {
    return sum + gsf__vd_half_simd128(v + __builtin_shufflevector(v, v, 2, 3, 2, 3), 0);
}

#endif

GSF__INLINE_SIMD128 void gsf__v_transpose_simd128(gsf__vf_simd128* m) {
    const gsf__vf_simd128 a = gsf__v_mix_low_simd128(m[0], m[2]), b = gsf__v_mix_low_simd128(m[1], m[3]);
    const gsf__vf_simd128 c = gsf__v_mix_high_simd128(m[0], m[2]), d = gsf__v_mix_high_simd128(m[1], m[3]);
    m[0] = gsf__v_mix_low_simd128(a, b);
    m[1] = gsf__v_mix_high_simd128(a, b);
    m[2] = gsf__v_mix_low_simd128(c, d);
    m[3] = gsf__v_mix_high_simd128(c, d);
}
GSF__INLINE_SIMD128 void gsf__vi_store_pairs_simd128(int32_t* p, gsf__vi_simd128 a, gsf__vi_simd128 b) {
    const gsf__vf_simd128 x = (gsf__vf_simd128)a, y = (gsf__vf_simd128)b;
    gsf__vi_store_simd128(p, (gsf__vi_simd128)gsf__v_mix_low_simd128(x, y));
    gsf__vi_store_simd128(p + 4, (gsf__vi_simd128)gsf__v_mix_high_simd128(x, y));
}

#endif // GSF__SIMD128

// Powers, in terms of the vocabulary. The scalar versions, which have no FMA, go through double.

#define gsf__v_exp2_terms GSF__V(gsf__v_exp2_terms)
#define gsf__v_exp2_of GSF__V(gsf__v_exp2_of)
#define gsf__v_exp2_low GSF__V(gsf__v_exp2_low)
#define gsf__v_power GSF__V(gsf__v_power)
#define gsf__v_exp2 GSF__V(gsf__v_exp2)
#define gsf__v_exp GSF__V(gsf__v_exp)

GSF__SHARED inline float gsf__v_exp2_scalar(float x) { return gsf__exp2_f32(x); }
GSF__SHARED inline float gsf__v_exp_scalar(float x) { return gsf__exp_f32(x); }

GSF__END_IMPLEMENTATION

#endif // GSF_INTERNALS_INCLUDED
#endif

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_BASE_IMPLEMENTATION)
#define GSFIXER_BASE_IMPLEMENTATION
#endif
#if defined(GSFIXER_BASE_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_BASE_IMPLEMENTED
#define GSF_BASE_IMPLEMENTED

#ifdef GSF_USE_OIIO
#ifndef __cplusplus
#error "GSF_USE_OIIO needs the implementation compiled as C++"
#endif
#include <memory>
#include <string>
#include <vector>
#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>
#endif

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

GSF_API const char* gsf_describe_cpu_level(gsf_cpu_level level) {
    switch (level) {
        case GSF_CPU_AUTO: return "auto";
        case GSF_CPU_SCALAR: return "scalar";
        case GSF_CPU_AVX2: return "avx2";
        case GSF_CPU_AVX512: return "avx512";
        case GSF_CPU_AVX512_VNNI: return "avx512_vnni";
        case GSF_CPU_AVX512_BF16: return "avx512_bf16";
        case GSF_CPU_AMX: return "amx";
        case GSF_CPU_SIMD128: return "simd128";
    }
    return "unknown";
}

#if GSF__X86
static void gsf__cpuid(unsigned leaf, unsigned subleaf, unsigned out[4]) { // eax, ebx, ecx, edx; 0 if there is no such leaf
    memset(out, 0, 4 * sizeof *out);
#if defined(_MSC_VER)
    int registers[4];
    __cpuid(registers, 0);
    if ((unsigned)registers[0] < leaf) return;
    __cpuidex(registers, (int)leaf, (int)subleaf);
    for (int i = 0; i < 4; i++) out[i] = (unsigned)registers[i];
#else
    if (!__get_cpuid_count(leaf, subleaf, &out[0], &out[1], &out[2], &out[3])) memset(out, 0, 4 * sizeof *out);
#endif
}

// Register state that the operating system saves (XCR0). Needs OSXSAVE.
static uint64_t gsf__saved_state(void) {
#if defined(_MSC_VER)
    return _xgetbv(0);
#else
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return (uint64_t)high << 32 | low;
#endif
}

// Whether threads of this process may use tiles: Linux wants to be asked, as they enlarge what it saves of a thread.
static int gsf__may_use_tiles(void) {
#if GSF__AMX
    long result = 158; // arch_prctl(ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA)
    __asm__ volatile("syscall" : "+a"(result) : "D"(0x1023l), "S"(18l) : "rcx", "r11", "memory");
    return result == 0;
#else
    return 0;
#endif
}
#endif

// By cpuid itself: __builtin_cpu_supports needs a run-time library that clang-cl does not link.
static gsf_cpu_level gsf__detect_cpu_level(void) {
#if GSF__X86
    const unsigned fma = 1u << 12, osxsave = 1u << 27, avx = 1u << 28, f16c = 1u << 29;             // leaf 1, ecx
    const unsigned bmi = 1u << 3, avx2 = 1u << 5, f_dq = 1u << 16 | 1u << 17, bw_vl = 3u << 30;     // leaf 7, ebx
    const unsigned vnni = 1u << 11, bf16 = 1u << 5;                                                 // ecx; leaf 7.1, eax
    const unsigned amx = 1u << 22 | 1u << 24 | 1u << 25;                                            // leaf 7, edx
    const uint64_t ymm = 6, zmm = 0xe6, tiles = 0x60000;                                            // in XCR0
    unsigned one[4], seven[4], more[4];
    gsf__cpuid(1, 0, one);
    gsf__cpuid(7, 0, seven);
    gsf__cpuid(7, 1, more);
    const unsigned first = fma | osxsave | avx | f16c;
    if ((one[2] & first) != first || (seven[1] & (bmi | avx2)) != (bmi | avx2)) return GSF_CPU_SCALAR;
    const uint64_t saved = gsf__saved_state();
    if ((saved & ymm) != ymm) return GSF_CPU_SCALAR;
    if ((saved & zmm) != zmm || (seven[1] & (f_dq | bw_vl)) != (f_dq | bw_vl)) return GSF_CPU_AVX2;
    if (!GSF__REACHES(GSF_CPU_AVX512, AVX512)) return GSF_CPU_AVX2;
    if (!(seven[2] & vnni)) return GSF_CPU_AVX512;
    if (!(more[0] & bf16)) return GSF_CPU_AVX512_VNNI;
    const int has_tiles = (seven[3] & amx) == amx && (saved & tiles) == tiles;
    return has_tiles && gsf__may_use_tiles() ? GSF_CPU_AMX : GSF_CPU_AVX512_BF16;
#else
    return GSF__SIMD128 ? GSF_CPU_SIMD128 : GSF_CPU_SCALAR;
#endif
}

// Intel's cores begin a bfloat16 dot product of 512 bits every second cycle, but two multiply-adds in each: half as many
// products (85 and 175 Gflop/s on Emerald Rapids). AMD's, since Zen 4, do twice as many.
static int gsf__bf16_is_slow(void) {
#if GSF__X86
    unsigned vendor[4];
    gsf__cpuid(0, 0, vendor);
    return vendor[1] == 0x756e6547u; // "Genu", of GenuineIntel
#else
    return 0;
#endif
}

GSF_API void gsf_log(gsf_context* ctx, gsf_log_level level, const char* format, ...) {
    if (!ctx->logger.log_fn) return;
    char text[1024];
    va_list args;
    va_start(args, format);
    GSF__VSNPRINTF(text, sizeof text, format, args);
    va_end(args);
    ctx->logger.log_fn(ctx->logger.user, level, text);
}

GSF_API gsf_result gsf_fail(gsf_context* ctx, gsf_result result, const char* format, ...) {
    char text[sizeof ctx->error]; // arguments may point into ctx->error
    va_list args;
    va_start(args, format);
    GSF__VSNPRINTF(text, sizeof text, format, args);
    va_end(args);
    for (char* c = text; *c; c++)
        if ((unsigned char)*c < 0x20 || *c == 0x7f) *c = '?';
    memcpy(ctx->error, text, sizeof text);
    if (ctx->logger.log_fn) ctx->logger.log_fn(ctx->logger.user, GSF_LOG_ERROR, ctx->error);
    return result;
}

GSF_API void gsf_request_cancel(gsf_context* ctx) { GSF__ATOMIC_STORE(&ctx->cancel, 1); }
GSF_API void gsf_clear_cancel(gsf_context* ctx) { GSF__ATOMIC_STORE(&ctx->cancel, 0); }
GSF_API int32_t gsf_is_cancelled(const gsf_context* ctx) { return GSF__ATOMIC_LOAD(&ctx->cancel) != 0; }

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
    // layout: [padding][pointer returned by the hook][aligned block]
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
    const int workers = (int)(intptr_t)user; // not a pointer to the context: the host may move that struct
    const int64_t count = (int64_t)chunk_count;
#pragma omp parallel for schedule(dynamic, 1) num_threads(workers)
    for (int64_t i = 0; i < count; i++) body(arg, (size_t)i, omp_get_thread_num());
}
#endif

static gsf_result gsf__stdio_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size);
static gsf_result gsf__stdio_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size);
static gsf_result gsf__json_parse(gsf_context* ctx, const char* name, const char* text, size_t size, size_t start,
                                  gsf_json* out);
static gsf_result gsf__lz_compress(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_buffer* out);
static gsf_result gsf__stb_inflate(gsf_context* ctx, const char* name, const void* data, size_t size, size_t body, void* out,
                                   size_t room);

static const gsf__services gsf__own_services = {gsf__stb_inflate, gsf__lz_compress, gsf__json_parse, gsf__stdio_read};

GSF_API gsf_result gsf_init_context(gsf_context* ctx) {
    if (!ctx) return GSF_ERROR_INVALID_ARGUMENT;
    ctx->error[0] = 0;
    ctx->services = &gsf__own_services;
    if (!ctx->allocator.alloc_fn != !ctx->allocator.free_fn)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "allocator: set both functions or neither");
    if (!ctx->io.read_fn != !ctx->io.write_fn)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "io: set both functions or neither");
    if (ctx->parallel.for_fn && ctx->parallel.worker_count < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "parallel: worker_count is %d", ctx->parallel.worker_count);
    if (!ctx->parallel.for_fn && ctx->parallel.worker_count && !ctx->threads)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "parallel: worker_count without for_fn; `threads` sets OpenMP's");
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
        ctx->parallel.worker_count = ctx->threads ? ctx->threads : omp_get_max_threads();
        ctx->parallel.user = (void*)(intptr_t)ctx->parallel.worker_count;
#else
        ctx->parallel.for_fn = gsf__for_serial;
        ctx->parallel.worker_count = 1;
#endif
    }
    const gsf_cpu_level best = gsf__detect_cpu_level();
    if (ctx->cpu_level == GSF_CPU_AUTO)
        ctx->cpu_level = best == GSF_CPU_AVX512_BF16 && gsf__bf16_is_slow() ? GSF_CPU_AVX512_VNNI : best;
    if (ctx->cpu_level > best) ctx->cpu_level = best;
    if (best == GSF_CPU_SIMD128 && ctx->cpu_level != best) ctx->cpu_level = GSF_CPU_SCALAR; // levels of x86
    ctx->initialized = 1;
    return GSF_OK;
}

// ---- >>random ------------------------------------------------------------------

// The finaliser of splitmix64 (Steele et al. 2014).
static uint64_t gsf__mix64(uint64_t x) {
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}

// Three rounds; each mixes in another word of the key first.
GSF_API uint64_t gsf_draw_bits(uint64_t seed, uint64_t stream, uint64_t index) {
    uint64_t x = gsf__mix64(seed + 0x9e3779b97f4a7c15u);
    x = gsf__mix64(x ^ (stream * 0xd1342543de82ef95u + 0x2545f4914f6cdd1du));
    return gsf__mix64(x ^ (index * 0x9e3779b97f4a7c15u + 0x632be59bd9b4e019u));
}

GSF_API double gsf_draw_uniform(uint64_t seed, uint64_t stream, uint64_t index) {
    return (double)(gsf_draw_bits(seed, stream, index) >> 11) * (1.0 / 9007199254740992.0);
}

GSF_API double gsf_draw_normal(uint64_t seed, uint64_t stream, uint64_t index) { // Box-Muller
    const double u = 1.0 - gsf_draw_uniform(seed, stream, 2 * index);
    const double v = gsf_draw_uniform(seed, stream, 2 * index + 1);
    return sqrt(-2.0 * gsf__log_f64(u)) * gsf__cos_f64(6.283185307179586 * v);
}

// ---- >>text --------------------------------------------------------------------

GSF_API void gsf_append_bytes(gsf_context* ctx, gsf_buffer* text, const char* data, size_t size) {
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

GSF_API void gsf_append_text(gsf_context* ctx, gsf_buffer* text, const char* format, ...) {
    va_list args, again;
    va_start(args, format);
    va_copy(again, args);
    char inside[512];
    const int length = GSF__VSNPRINTF(inside, sizeof inside, format, args);
    va_end(args);
    if (length < 0) {
        text->failed = 1;
    } else if ((size_t)length < sizeof inside) {
        gsf_append_bytes(ctx, text, inside, (size_t)length);
    } else if (!text->failed) {
        if (gsf__reserve(ctx, (void**)&text->data, &text->capacity, text->size, text->size + (size_t)length + 1, 1) ==
            GSF_OK) {
            GSF__VSNPRINTF(text->data + text->size, (size_t)length + 1, format, again);
            text->size += (size_t)length;
        } else {
            text->failed = 1;
        }
    }
    va_end(again);
}

GSF_API void gsf_append_json_string(gsf_context* ctx, gsf_buffer* text, const char* string) {
    const char* p = string ? string : "";
    size_t left = strlen(p);
    gsf_append_bytes(ctx, text, "\"", 1);
    while (left) {
        size_t plain = 0; // bytes that need no escape
        size_t step;
        while (plain < left && (unsigned char)p[plain] >= 0x20 && p[plain] != '"' && p[plain] != '\\' &&
               (step = gsf__utf8_size(p + plain, left - plain)) != 0)
            plain += step;
        gsf_append_bytes(ctx, text, p, plain);
        p += plain;
        left -= plain;
        if (!left) break;
        const unsigned char c = (unsigned char)*p++;
        left--;
        if (c == '"' || c == '\\') gsf_append_text(ctx, text, "\\%c", c);
        else if (c < 0x20) gsf_append_text(ctx, text, "\\u%04x", (unsigned)c);
        else gsf_append_bytes(ctx, text, "\\ufffd", 6); // not UTF-8
    }
    gsf_append_bytes(ctx, text, "\"", 1);
}

// Prints as few of 15 to 17 digits as read back as the same double, with '.' as the decimal point in every locale.
GSF_API void gsf_append_json_number(gsf_context* ctx, gsf_buffer* text, double value) {
    if (!isfinite(value)) {
        gsf_append_bytes(ctx, text, "null", 4);
        return;
    }
    char printed[64], plain[64];
    size_t size = 0;
    for (int digits = 15; digits <= 17; digits++) {
        snprintf(printed, sizeof printed, "%.*g", digits, value);
        size = 0;
        for (const char* p = printed; *p; p++) {
            if ((*p >= '0' && *p <= '9') || *p == '-' || *p == '+' || *p == 'e') plain[size++] = *p;
            else if (size == 0 || plain[size - 1] != '.') plain[size++] = '.'; // some locales' takes several bytes
        }
        double back = 0.0;
        if (gsf__scan_double(plain, size, &back) == size && back == value) break;
    }
    gsf_append_bytes(ctx, text, plain, size);
}

GSF_API void gsf_destroy_buffer(gsf_context* ctx, gsf_buffer* text) {
    gsf_free(ctx, text->data);
    memset(text, 0, sizeof *text);
}

// ---- >>files -------------------------------------------------------------------

// Opens a file for reading; *out is NULL on failure. Opening a pipe would block until it has a writer, and a device may never
// end.
static gsf_result gsf__open_file(gsf_context* ctx, const char* path, FILE** out) {
    const gsf__path_kind kind = gsf__look_at_path(ctx, path);
    const char* reason = kind == GSF__PATH_FOLDER ? "is a folder" : kind == GSF__PATH_DEVICE ? "is not a regular file" : NULL;
    errno = 0;
    *out = reason ? NULL : gsf__open_path(ctx, path, GSF__OPEN_READ);
    if (*out) return GSF_OK;
    return gsf_fail(ctx, gsf__open_result(errno), "%s: %s", path, reason ? reason : strerror(errno));
}

// Reads 64 KiB first and then the rest at once. The reported size only sets how much is read at a time, because it can be
// wrong (files in /proc report 0).
static gsf_result gsf__stdio_read(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    (void)user;
    FILE* file;
    GSF__TRY(gsf__open_file(ctx, path, &file));
    gsf_buffer buffer;
    memset(&buffer, 0, sizeof buffer);
    gsf_result result = GSF_OK;
    size_t step = 1 << 16;
    for (;;) {
        result = gsf__reserve(ctx, (void**)&buffer.data, &buffer.capacity, buffer.size, buffer.size + step + 1, 1);
        if (result != GSF_OK) break;
        const size_t got = fread(buffer.data + buffer.size, 1, step, file);
        const int first = buffer.size == 0;
        buffer.size += got;
        if (got < step) {
            if (ferror(file)) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
            break;
        }
        if (first && gsf__seek(file, 0, SEEK_END) == 0) {
            const int64_t end = gsf__tell(file);
            if (end >= 0 && (uint64_t)end >= buffer.size && (uint64_t)end < SIZE_MAX / 2)
                step = (size_t)end - buffer.size + 1;  // + 1, so that fread reaches the end of the file
            if (gsf__seek(file, (int64_t)buffer.size, SEEK_SET) != 0) {
                result = gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
                break;
            }
        }
    }
    fclose(file);
    if (result != GSF_OK) {
        gsf_destroy_buffer(ctx, &buffer);
        return result;
    }
    buffer.data[buffer.size] = 0;
    *data = buffer.data;
    *size = buffer.size;
    return GSF_OK;
}

// Creates a temporary file next to `path` and stores its name in `name`. Existing files and links are never opened: they
// may belong to somebody else.
static FILE* gsf__open_new(gsf_context* ctx, const char* path, gsf_buffer* name) {
    for (int i = 0; i < 100; i++) {
        name->size = 0;
        gsf_append_text(ctx, name, i ? "%s.tmp%d" : "%s.tmp", path, i);
        errno = 0;
        FILE* file = name->failed ? NULL : gsf__open_path(ctx, name->data, GSF__OPEN_NEW);
        if (file || name->failed || errno != EEXIST) return file;
    }
    return NULL;
}

// Writes a temporary file and renames it, so that `path` always holds a complete file, even if the process is killed. A
// power failure can still lose data, because there is no fsync.
static gsf_result gsf__stdio_write(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    (void)user;
    const int device = gsf__look_at_path(ctx, path) == GSF__PATH_DEVICE; // as /dev/stdout: a rename would replace it
    gsf_buffer name;
    memset(&name, 0, sizeof name);
    gsf_result result = GSF_OK;
    FILE* file = device ? gsf__open_path(ctx, path, GSF__OPEN_WRITE) : gsf__open_new(ctx, path, &name);
    if (name.failed) {
        result = GSF_ERROR_OUT_OF_MEMORY;
    } else if (!file) {
        result = gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, strerror(errno));
    } else {
        errno = 0;
        int ok = (size == 0 || fwrite(data, 1, size, file) == size) && fflush(file) == 0;
        int reason = errno;
        if (fclose(file) != 0 && ok) {
            ok = 0;
            reason = errno;
        }
        if (ok && !device && gsf__replace_path(ctx, name.data, path) != 0) {
            ok = 0;
            reason = errno;
        }
        if (!ok) {
            if (!device) gsf__remove_path(ctx, name.data);
            result = gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, strerror(reason));
        }
    }
    gsf_destroy_buffer(ctx, &name);
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

GSF_API void gsf_append_chunk(gsf_context* ctx, gsf_buffer* out, const char* tag, const void* data, size_t size) {
    const size_t opened = gsf__open_chunk(ctx, out, tag);
    gsf_append_bytes(ctx, out, (const char*)data, size);
    gsf__close_chunk(ctx, out, opened);
}

GSF_API void gsf_append_last_chunk(gsf_context* ctx, gsf_buffer* out) { gsf_append_chunk(ctx, out, "END ", "", 0); }

GSF_API gsf_result gsf_check_chunks(gsf_context* ctx, const char* name, const void* data, size_t size) {
    const char* p = (const char*)data;
    if (size < GSF__CHUNK_FILE_HEAD || memcmp(p, "GSFCHUNK", 8) != 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: not a checkpoint (magic GSFCHUNK expected)", name);
    if (gsf__load_le(p + 8, 4) != 1)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:8: checkpoint version %u, this program reads 1", name,
                        (unsigned)gsf__load_le(p + 8, 4));
    for (size_t at = GSF__CHUNK_FILE_HEAD;;) {
        if (size - at < GSF__CHUNK_HEAD + GSF__CHUNK_TAIL)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file is truncated (no END chunk)", name, at);
        const uint64_t bytes = gsf__load_le(p + at + 4, 8);
        if (bytes > size - at - GSF__CHUNK_HEAD - GSF__CHUNK_TAIL)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: chunk of %llu bytes does not fit the file", name, at,
                            (unsigned long long)bytes);
        const char* body = p + at + GSF__CHUNK_HEAD;
        if (gsf__crc32(gsf__crc32(0, p + at, GSF__CHUNK_HEAD), body, (size_t)bytes) !=
            (uint32_t)gsf__load_le(body + bytes, 4))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: checksum mismatch", name, at);
        const int last = memcmp(p + at, "END ", 4) == 0;
        at += GSF__CHUNK_HEAD + (size_t)bytes + GSF__CHUNK_TAIL;
        if (last && (bytes != 0 || at != size))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: bytes after the end", name, at - (size_t)bytes);
        if (last) return GSF_OK;
    }
}

GSF_API int32_t gsf_find_chunk(const void* data, size_t size, const char* tag, gsf_chunk* out) {
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

enum { GSF__JSON_DEPTH = 64, GSF__JSON_FEW_MEMBERS = 16 };

typedef struct gsf__json_parser {
    gsf_context* ctx;
    const char* name;
    const char* text;
    size_t size, at;
    gsf_json* out;
    size_t value_capacity;
    char* free_string;     // next unused byte of out->strings
    uint64_t* order;       // scratch for finding duplicate keys: hash << 32 | index
    size_t order_capacity;
} gsf__json_parser;

static int gsf__json_peek(const gsf__json_parser* p) { return p->at < p->size ? (unsigned char)p->text[p->at] : -1; }

static void gsf__json_skip_space(gsf__json_parser* p) {
    for (; p->at < p->size; p->at++) {
        const char c = p->text[p->at];
        if (c != ' ' && c != '\n' && c != '\r' && c != '\t') return;
    }
}

static gsf_result gsf__json_fail(const gsf__json_parser* p, const char* expected) {
    const int c = gsf__json_peek(p);
    char got[32];
    if (c < 0) snprintf(got, sizeof got, "the end of the text");
    else if (c > 0x20 && c < 0x7f) snprintf(got, sizeof got, "'%c'", c);
    else snprintf(got, sizeof got, "byte 0x%02x", (unsigned)c);
    return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s:%zu: expected %s, got %s", p->name, p->at, expected, got);
}

// Upper bounds from one pass over the text: every value but the root follows a '[', '{' or ',', and a decoded string is
// never longer than its source.
static void gsf__json_measure(const char* text, size_t size, size_t* values, size_t* string_bytes) {
    *values = 1;
    *string_bytes = 1;
    for (size_t i = 0; i < size; i++) {
        const char c = text[i];
        if (c == ',' || c == '[' || c == '{') {
            (*values)++;
        } else if (c == '"') {
            const size_t start = ++i;
            while (i < size && text[i] != '"') i += text[i] == '\\' ? 2 : 1;
            *string_bytes += (i < size ? i : size) - start + 1;
        }
    }
}

static gsf_result gsf__json_read_hex4(gsf__json_parser* p, uint32_t* out) {
    *out = 0;
    for (int i = 0; i < 4; i++, p->at++) {
        const int c = gsf__json_peek(p);
        const int digit = c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10
                          : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
        if (digit < 0) return gsf__json_fail(p, "a hexadecimal digit");
        *out = *out << 4 | (uint32_t)digit;
    }
    return GSF_OK;
}

// Reads an escape sequence from after its backslash and appends the character to p->free_string as UTF-8.
static gsf_result gsf__json_read_escape(gsf__json_parser* p) {
    static const char from[] = "\"\\/bfnrt", to[] = "\"\\/\b\f\n\r\t";
    const int c = gsf__json_peek(p);
    if (c != 'u') {
        const char* found = c > 0 ? strchr(from, c) : NULL;
        if (!found) return gsf__json_fail(p, "an escape character");
        *p->free_string++ = to[found - from];
        p->at++;
        return GSF_OK;
    }
    const size_t start = p->at - 1;
    uint32_t code, low;
    p->at++;
    GSF__TRY(gsf__json_read_hex4(p, &code));
    if (code >= 0xd800 && code < 0xdc00) {
        if (p->size - p->at < 2 || p->text[p->at] != '\\' || p->text[p->at + 1] != 'u')
            return gsf__json_fail(p, "the second half of a surrogate pair");
        p->at += 2;
        GSF__TRY(gsf__json_read_hex4(p, &low));
        if (low < 0xdc00 || low > 0xdfff)
            return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s:%zu: half a surrogate pair", p->name, start);
        code = 0x10000 + ((code - 0xd800) << 10) + (low - 0xdc00);
    } else if (code >= 0xdc00 && code < 0xe000) {
        return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s:%zu: half a surrogate pair", p->name, start);
    }
    unsigned char* s = (unsigned char*)p->free_string;
    if (code < 0x80) {
        *s++ = (unsigned char)code;
    } else if (code < 0x800) {
        *s++ = (unsigned char)(0xc0 | code >> 6);
        *s++ = (unsigned char)(0x80 | (code & 0x3f));
    } else if (code < 0x10000) {
        *s++ = (unsigned char)(0xe0 | code >> 12);
        *s++ = (unsigned char)(0x80 | (code >> 6 & 0x3f));
        *s++ = (unsigned char)(0x80 | (code & 0x3f));
    } else {
        *s++ = (unsigned char)(0xf0 | code >> 18);
        *s++ = (unsigned char)(0x80 | (code >> 12 & 0x3f));
        *s++ = (unsigned char)(0x80 | (code >> 6 & 0x3f));
        *s++ = (unsigned char)(0x80 | (code & 0x3f));
    }
    p->free_string = (char*)s;
    return GSF_OK;
}

// Reads a string from its opening quote.
static gsf_result gsf__json_read_string(gsf__json_parser* p, const char** string, size_t* size) {
    char* const start = p->free_string;
    for (p->at++;;) {
        const int c = gsf__json_peek(p);
        if (c == '"') break;
        if (c < 0) return gsf__json_fail(p, "the end of a string");
        if (c < 0x20) return gsf__json_fail(p, "a character (control characters must be escaped)");
        if (c == '\\') {
            p->at++;
            GSF__TRY(gsf__json_read_escape(p));
            continue;
        }
        const size_t bytes = gsf__utf8_size(p->text + p->at, p->size - p->at);
        if (bytes == 0) return gsf__json_fail(p, "UTF-8");
        memcpy(p->free_string, p->text + p->at, bytes);
        p->free_string += bytes;
        p->at += bytes;
    }
    p->at++;
    *string = start;
    *size = (size_t)(p->free_string - start);
    *p->free_string++ = 0;
    return GSF_OK;
}

static gsf_result gsf__json_skip_digits(gsf__json_parser* p) {
    const size_t start = p->at;
    while (gsf__json_peek(p) >= '0' && gsf__json_peek(p) <= '9') p->at++;
    return p->at > start ? GSF_OK : gsf__json_fail(p, "a digit");
}

static gsf_result gsf__json_read_number(gsf__json_parser* p, double* out) {
    const size_t start = p->at;
    if (gsf__json_peek(p) == '-') p->at++;
    if (gsf__json_peek(p) == '0') p->at++; // leading zeros are not allowed
    else GSF__TRY(gsf__json_skip_digits(p));
    if (gsf__json_peek(p) == '.') {
        p->at++;
        GSF__TRY(gsf__json_skip_digits(p));
    }
    if (gsf__json_peek(p) == 'e' || gsf__json_peek(p) == 'E') {
        p->at++;
        if (gsf__json_peek(p) == '-' || gsf__json_peek(p) == '+') p->at++;
        GSF__TRY(gsf__json_skip_digits(p));
    }
    (void)gsf__scan_double(p->text + start, p->at - start, out);
    if (!isfinite(*out))
        return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s:%zu: number is out of range", p->name, start);
    return GSF_OK;
}

static gsf_result gsf__json_read_scalar(gsf__json_parser* p, gsf_json_value* value) {
    static const struct { const char* word; gsf_json_type type; } words[] = {
        {"null", GSF_JSON_NULL}, {"false", GSF_JSON_FALSE}, {"true", GSF_JSON_TRUE}};
    const int c = gsf__json_peek(p);
    if (c == '"') {
        value->type = GSF_JSON_STRING;
        return gsf__json_read_string(p, &value->string, &value->string_size);
    }
    if (c == '-' || (c >= '0' && c <= '9')) {
        value->type = GSF_JSON_NUMBER;
        return gsf__json_read_number(p, &value->number);
    }
    for (size_t i = 0; i < GSF__COUNT(words); i++) {
        const size_t size = strlen(words[i].word);
        if (p->size - p->at < size || memcmp(p->text + p->at, words[i].word, size) != 0) continue;
        value->type = words[i].type;
        p->at += size;
        return GSF_OK;
    }
    return gsf__json_fail(p, "a value");
}

static gsf_result gsf__json_read_key(gsf__json_parser* p, gsf_json_value* value) {
    if (gsf__json_peek(p) != '"') return gsf__json_fail(p, "a key in quotes");
    size_t size;
    GSF__TRY(gsf__json_read_string(p, &value->key, &size));
    value->key_size = (uint32_t)size;
    gsf__json_skip_space(p);
    if (gsf__json_peek(p) != ':') return gsf__json_fail(p, "':'");
    p->at++;
    gsf__json_skip_space(p);
    return GSF_OK;
}

// Orders two entries by hash, then by key, so that equal keys become neighbours even if other keys have the same hash.
static int gsf__json_compare_keys(const gsf_json_value* values, uint64_t a, uint64_t b) {
    if (a >> 32 != b >> 32) return a >> 32 < b >> 32 ? -1 : 1;
    const gsf_json_value *x = &values[a & 0xffffffffu], *y = &values[b & 0xffffffffu];
    if (x->key_size != y->key_size) return x->key_size < y->key_size ? -1 : 1;
    return memcmp(x->key, y->key, x->key_size);
}

// Bottom-up merge sort of n entries; the second half of `order` (2n long) is scratch. Returns the sorted half.
static uint64_t* gsf__json_sort_keys(const gsf_json_value* values, uint64_t* order, size_t n) {
    uint64_t *from = order, *to = order + n;
    for (size_t run = 1; run < n; run *= 2) {
        for (size_t start = 0; start < n; start += 2 * run) {
            const size_t middle = start + run < n ? start + run : n, end = middle + run < n ? middle + run : n;
            size_t i = start, j = middle, k = start;
            while (i < middle && j < end)
                to[k++] = gsf__json_compare_keys(values, from[j], from[i]) < 0 ? from[j++] : from[i++];
            while (i < middle) to[k++] = from[i++];
            while (j < end) to[k++] = from[j++];
        }
        uint64_t* swap = from;
        from = to;
        to = swap;
    }
    return from;
}

// Compares few keys pairwise and sorts many, so that the time is O(n log n) for any file.
static gsf_result gsf__json_refuse_duplicates(gsf__json_parser* p, const gsf_json_value* object) {
    const gsf_json_value* values = p->out->values;
    const size_t n = object->count;
    const gsf_json_value* twice = NULL;
    if (n <= GSF__JSON_FEW_MEMBERS) {
        for (uint32_t i = object->child; i && !twice; i = values[i].next)
            for (uint32_t j = object->child; j != i && !twice; j = values[j].next)
                if (values[i].key_size == values[j].key_size &&
                    memcmp(values[i].key, values[j].key, values[i].key_size) == 0)
                    twice = &values[i];
    } else {
        GSF__TRY(gsf__reserve(p->ctx, (void**)&p->order, &p->order_capacity, 0, 2 * n, sizeof(uint64_t)));
        size_t k = 0;
        for (uint32_t i = object->child; i; i = values[i].next) {
            uint32_t hash = 2166136261u; // FNV-1a
            for (uint32_t c = 0; c < values[i].key_size; c++)
                hash = (hash ^ (unsigned char)values[i].key[c]) * 16777619u;
            p->order[k++] = (uint64_t)hash << 32 | i;
        }
        const uint64_t* sorted = gsf__json_sort_keys(values, p->order, n);
        for (k = 1; k < n && !twice; k++)
            if (gsf__json_compare_keys(values, sorted[k - 1], sorted[k]) == 0) twice = &values[sorted[k] & 0xffffffffu];
    }
    if (!twice) return GSF_OK;
    char key[48];
    snprintf(key, sizeof key, "%.40s", twice->key);
    for (char* c = key; *c; c++)
        if (*c < 0x20 || *c > 0x7e) *c = '?';
    return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s:%u: key \"%s\" occurs twice in one object", p->name,
                    (unsigned)twice->offset, key);
}

static gsf_result gsf__json_read_document(gsf__json_parser* p) {
    uint32_t parent[GSF__JSON_DEPTH], last[GSF__JSON_DEPTH]; // of the open containers: index, and last child so far
    size_t depth = 0;
    gsf_json_value* values = p->out->values;
    for (;;) {
        GSF_ASSERT(p->out->count < p->value_capacity);
        const uint32_t index = (uint32_t)p->out->count++;
        gsf_json_value* value = &values[index];
        memset(value, 0, sizeof *value);
        gsf__json_skip_space(p);
        if (depth) {
            gsf_json_value* owner = &values[parent[depth - 1]];
            if (owner->count++ == 0) owner->child = index;
            else values[last[depth - 1]].next = index;
            last[depth - 1] = index;
            if (owner->type == GSF_JSON_OBJECT) GSF__TRY(gsf__json_read_key(p, value));
        }
        value->offset = (uint32_t)p->at;
        const int c = gsf__json_peek(p);
        if (c == '{' || c == '[') {
            if (depth == GSF__JSON_DEPTH)
                return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s:%zu: more than %d levels deep", p->name, p->at,
                                (int)GSF__JSON_DEPTH);
            value->type = c == '{' ? GSF_JSON_OBJECT : GSF_JSON_ARRAY;
            p->at++;
            gsf__json_skip_space(p);
            if (gsf__json_peek(p) != (c == '{' ? '}' : ']')) {
                parent[depth++] = index;
                continue;
            }
            p->at++;
        } else {
            GSF__TRY(gsf__json_read_scalar(p, value));
        }
        for (;;) { // a value is complete: close the containers that end after it
            gsf__json_skip_space(p);
            if (depth == 0) return p->at == p->size ? GSF_OK : gsf__json_fail(p, "the end of the text");
            const gsf_json_value* owner = &values[parent[depth - 1]];
            const int is_object = owner->type == GSF_JSON_OBJECT;
            if (gsf__json_peek(p) == ',') {
                p->at++;
                break;
            }
            if (gsf__json_peek(p) != (is_object ? '}' : ']'))
                return gsf__json_fail(p, is_object ? "',' or '}'" : "',' or ']'");
            p->at++;
            depth--;
            if (is_object) GSF__TRY(gsf__json_refuse_duplicates(p, owner));
        }
    }
}

GSF_API gsf_result gsf_parse_json(gsf_context* ctx, const char* name, const char* text, size_t size, gsf_json* out) {
    return gsf__parse_json_from(ctx, name, text, size, 0, out);
}

static gsf_result gsf__json_parse(gsf_context* ctx, const char* name, const char* text, size_t size, size_t start,
                                  gsf_json* out) {
    memset(out, 0, sizeof *out);
    snprintf(out->name, sizeof out->name, "%s", name ? name : "json");
    if (size > 0xfffffff0u)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: JSON of %zu bytes (at most 4 GiB)", out->name, size);
    if (size - start >= 3 && memcmp(text + start, "\xef\xbb\xbf", 3) == 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: expected a value, got a byte order mark", out->name, start);
    gsf__json_parser p;
    memset(&p, 0, sizeof p);
    p.ctx = ctx;
    p.name = out->name;
    p.text = text;
    p.size = size;
    p.at = start;
    p.out = out;
    size_t string_bytes;
    gsf__json_measure(text + start, size - start, &p.value_capacity, &string_bytes);
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    out->values = (gsf_json_value*)gsf_alloc(ctx, p.value_capacity, sizeof *out->values);
    if (out->values) out->strings = (char*)gsf_alloc(ctx, string_bytes, 1);
    if (out->strings) {
        p.free_string = out->strings;
        result = gsf__json_read_document(&p);
    }
    gsf_free(ctx, p.order);
    if (result != GSF_OK) gsf_destroy_json(ctx, out);
    return result;
}

GSF_API void gsf_destroy_json(gsf_context* ctx, gsf_json* json) {
    gsf_free(ctx, json->values);
    gsf_free(ctx, json->strings);
    memset(json, 0, sizeof *json);
}

GSF_API const gsf_json_value* gsf_find_json_member(const gsf_json* json, const gsf_json_value* object,
                                                   const char* key) {
    if (!object || object->type != GSF_JSON_OBJECT) return NULL;
    const size_t size = strlen(key);
    for (uint32_t i = object->child; i; i = json->values[i].next)
        if (json->values[i].key_size == size && memcmp(json->values[i].key, key, size) == 0) return &json->values[i];
    return NULL;
}

GSF_API const gsf_json_value* gsf_find_json_element(const gsf_json* json, const gsf_json_value* array, size_t index) {
    if (!array || array->type != GSF_JSON_ARRAY || index >= array->count) return NULL;
    uint32_t i = array->child;
    while (index--) i = json->values[i].next;
    return &json->values[i];
}

// ---- >>deflate -----------------------------------------------------------------
// DEFLATE encoder (RFC 1951). All its memory is one allocation. Each compressed block has its own Huffman codes.

enum {
    GSF__LZ_WINDOW = 1 << 15, GSF__LZ_SHORTEST = 3, GSF__LZ_LONGEST = 258, GSF__LZ_GOOD = 32, GSF__LZ_TRIES = 16,
    GSF__LZ_TOKENS = 1 << 15,
    GSF__LITERALS = 286, GSF__DISTANCES = 30, GSF__LENGTH_CODES = 19, GSF__BLOCK_END = 256
};

typedef struct gsf__deflater {
    gsf_context* ctx;
    gsf_buffer* out;
    uint64_t bits; // not yet moved to `buffer`
    int bit_count;
    size_t used;
    unsigned char buffer[4096]; // not yet appended to `out`
    const unsigned char* data;
    size_t size;
    int32_t head[GSF__LZ_WINDOW];     // by hash of three bytes: their latest position, -1 = none
    int32_t previous[GSF__LZ_WINDOW]; // by position modulo the window: the previous one of that hash
    uint32_t tokens[GSF__LZ_TOKENS];  // literal, or length << 16 | distance
    size_t token_count;
    size_t block_begin; // position in `data` of the first token
    uint32_t literal_counts[GSF__LITERALS], distance_counts[GSF__DISTANCES];
} gsf__deflater;

static void gsf__put_bits(gsf__deflater* d, uint32_t value, int count) {
    d->bits |= (uint64_t)value << d->bit_count;
    for (d->bit_count += count; d->bit_count >= 8; d->bit_count -= 8, d->bits >>= 8) {
        d->buffer[d->used++] = (unsigned char)(d->bits & 255u);
        if (d->used < sizeof d->buffer) continue;
        gsf_append_bytes(d->ctx, d->out, (const char*)d->buffer, d->used);
        d->used = 0;
    }
}

// A length or distance as DEFLATE codes it: symbol, and extra bits with their number.
typedef struct gsf__lz_class { uint32_t code, extra; int extra_bits; } gsf__lz_class;

static gsf__lz_class gsf__lz_class_of(uint32_t value, int fraction_bits) {
    gsf__lz_class c;
    for (c.extra_bits = 0; value >> c.extra_bits >> (fraction_bits + 1);) c.extra_bits++;
    c.code = ((uint32_t)c.extra_bits << fraction_bits) + (value >> c.extra_bits);
    c.extra = value & ((1u << c.extra_bits) - 1u);
    return c;
}

static gsf__lz_class gsf__length_class(uint32_t length) {
    gsf__lz_class c = gsf__lz_class_of(length - GSF__LZ_SHORTEST, 2);
    if (length == GSF__LZ_LONGEST) { // the longest match has its own code
        c.code = 28;
        c.extra = 0;
        c.extra_bits = 0;
    }
    c.code += GSF__BLOCK_END + 1;
    return c;
}

static gsf__lz_class gsf__distance_class(uint32_t distance) { return gsf__lz_class_of(distance - 1, 1); }

// Lengths of Huffman codes, of at most `limit` bits. At least two symbols get a code, because some decoders reject a single
// one. Counts are made coarser until the longest code fits. That ends: once all counts are equal, the 286 literal codes have
// at most nine bits (limit 15) and the 19 length codes at most five (limit 7).
static void gsf__huffman_lengths(uint32_t* counts, int symbols, int limit, uint8_t* lengths) {
    int32_t order[GSF__LITERALS], parent[2 * GSF__LITERALS];
    uint32_t weight[2 * GSF__LITERALS];
    uint8_t depth[2 * GSF__LITERALS];
    int used = 0;
    for (int s = 0; s < symbols; s++) used += counts[s] != 0;
    for (int s = 0; used < 2; s++)
        if (!counts[s]) counts[s] = 1, used++;
    for (int coarse = 0;; coarse++) {
        int n = 0;
        for (int s = 0; s < symbols; s++) { // insertion sort by weight
            if (!counts[s]) continue;
            const uint32_t w = ((counts[s] - 1) >> coarse) + 1;
            int at = n++;
            for (; at > 0 && weight[at - 1] > w; at--) weight[at] = weight[at - 1], order[at] = order[at - 1];
            weight[at] = w;
            order[at] = s;
        }
        for (int node = n, leaf = 0, inner = n; node < 2 * n - 1; node++) { // leaves and inner nodes: two sorted queues
            weight[node] = 0;
            for (int child = 0; child < 2; child++) {
                const int taken = leaf < n && (inner >= node || weight[leaf] <= weight[inner]) ? leaf++ : inner++;
                weight[node] += weight[taken];
                parent[taken] = node;
            }
        }
        depth[2 * n - 2] = 0;
        for (int node = 2 * n - 3; node >= 0; node--) depth[node] = (uint8_t)(depth[parent[node]] + 1);
        if (depth[0] > limit) continue;
        memset(lengths, 0, (size_t)symbols);
        for (int i = 0; i < n; i++) lengths[order[i]] = depth[i];
        return;
    }
}

// Canonical codes, bit-reversed: DEFLATE stores the first bit of a Huffman code as the lowest.
static void gsf__huffman_codes(const uint8_t* lengths, int symbols, uint16_t* codes) {
    uint32_t code = 0;
    for (int bits = 1; bits < 16; bits++, code <<= 1)
        for (int s = 0; s < symbols; s++) {
            if (lengths[s] != bits) continue;
            uint32_t turned = 0;
            for (int b = 0; b < bits; b++) turned |= (code >> b & 1u) << (bits - 1 - b);
            codes[s] = (uint16_t)turned;
            code++;
        }
}

// The code lengths of a block, run-length coded (symbol 16 repeats the previous length, 17 and 18 repeat zero) and then
// Huffman coded. Returns their size in bits; writes them if `write` is set.
static size_t gsf__put_lengths(gsf__deflater* d, const uint8_t* lengths, int count, int write) {
    static const uint8_t sent[GSF__LENGTH_CODES] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    uint8_t symbols[GSF__LITERALS + GSF__DISTANCES], repeats[GSF__LITERALS + GSF__DISTANCES];
    uint8_t bits[GSF__LENGTH_CODES];
    uint16_t codes[GSF__LENGTH_CODES];
    uint32_t counts[GSF__LENGTH_CODES];
    int n = 0;
    memset(counts, 0, sizeof counts);
    for (int i = 0; i < count;) {
        int run = 1;
        while (i + run < count && lengths[i + run] == lengths[i] && run < 138) run++;
        const int again = i > 0 && lengths[i] == lengths[i - 1];
        int symbol = lengths[i];
        if (symbol == 0 && run >= 3) symbol = run < 11 ? 17 : 18;
        else if (again && run >= 3) symbol = 16;
        if (symbol == 16 && run > 6) run = 6;
        if (symbol < 16) run = 1;
        repeats[n] = (uint8_t)(run - (symbol == 18 ? 11 : symbol >= 16 ? 3 : 1));
        symbols[n++] = (uint8_t)symbol;
        counts[symbol]++;
        i += run;
    }
    gsf__huffman_lengths(counts, GSF__LENGTH_CODES, 7, bits);
    gsf__huffman_codes(bits, GSF__LENGTH_CODES, codes);
    size_t total = 3 * GSF__LENGTH_CODES;
    for (int i = 0; write && i < GSF__LENGTH_CODES; i++) gsf__put_bits(d, bits[sent[i]], 3);
    for (int i = 0; i < n; i++) {
        const int extra = symbols[i] < 16 ? 0 : symbols[i] == 16 ? 2 : symbols[i] == 17 ? 3 : 7;
        total += (size_t)(bits[symbols[i]] + extra);
        if (!write) continue;
        gsf__put_bits(d, codes[symbols[i]], bits[symbols[i]]);
        gsf__put_bits(d, repeats[i], extra);
    }
    return total;
}

// Size in bits of a block's tokens, including the end-of-block symbol.
static size_t gsf__token_bits(const gsf__deflater* d, const uint8_t* bits, const uint8_t* distance_bits) {
    size_t total = 0;
    for (int i = 0; i < GSF__LITERALS; i++) total += (size_t)d->literal_counts[i] * bits[i];
    for (int i = 0; i < GSF__DISTANCES; i++) total += (size_t)d->distance_counts[i] * distance_bits[i];
    for (size_t i = 0; i < d->token_count; i++) {
        const uint32_t length = d->tokens[i] >> 16;
        if (!length) continue;
        total += (size_t)gsf__length_class(length).extra_bits;
        total += (size_t)gsf__distance_class(d->tokens[i] & 0xffffu).extra_bits;
    }
    return total;
}

static void gsf__put_stored(gsf__deflater* d, int last, size_t size) {
    gsf__put_bits(d, (uint32_t)last, 3);
    gsf__put_bits(d, 0, (8 - d->bit_count) % 8);
    gsf__put_bits(d, (uint32_t)size, 16);
    gsf__put_bits(d, (uint32_t)size ^ 0xffffu, 16);
    for (size_t i = 0; i < size; i++) gsf__put_bits(d, d->data[d->block_begin + i], 8);
}

static void gsf__put_packed(gsf__deflater* d, int last, const uint8_t* bits) {
    const uint8_t* distance_bits = bits + GSF__LITERALS;
    uint16_t codes[GSF__LITERALS], distance_codes[GSF__DISTANCES];
    gsf__huffman_codes(bits, GSF__LITERALS, codes);
    gsf__huffman_codes(distance_bits, GSF__DISTANCES, distance_codes);
    gsf__put_bits(d, (uint32_t)last | 2u << 1, 3); // block type 2: dynamic Huffman codes
    gsf__put_bits(d, GSF__LITERALS - 257, 5);
    gsf__put_bits(d, GSF__DISTANCES - 1, 5);
    gsf__put_bits(d, GSF__LENGTH_CODES - 4, 4);
    (void)gsf__put_lengths(d, bits, GSF__LITERALS + GSF__DISTANCES, 1);
    for (size_t i = 0; i < d->token_count; i++) {
        const uint32_t length = d->tokens[i] >> 16, low = d->tokens[i] & 0xffffu;
        if (!length) {
            gsf__put_bits(d, codes[low], bits[low]);
            continue;
        }
        const gsf__lz_class l = gsf__length_class(length), reach = gsf__distance_class(low);
        gsf__put_bits(d, codes[l.code], bits[l.code]);
        gsf__put_bits(d, l.extra, l.extra_bits);
        gsf__put_bits(d, distance_codes[reach.code], distance_bits[reach.code]);
        gsf__put_bits(d, reach.extra, reach.extra_bits);
    }
    gsf__put_bits(d, codes[GSF__BLOCK_END], bits[GSF__BLOCK_END]);
}

// Writes the block of all pending tokens, which ends before byte `end`; uncompressed if that is smaller.
static void gsf__put_block(gsf__deflater* d, int last, size_t end) {
    enum { PACKED_HEAD = 17, STORED_HEAD = 3 + 7 + 32, STORED_MOST = 65535 };
    uint8_t bits[GSF__LITERALS + GSF__DISTANCES], *distance_bits = bits + GSF__LITERALS;
    const size_t size = end - d->block_begin;
    d->literal_counts[GSF__BLOCK_END] = 1;
    gsf__huffman_lengths(d->literal_counts, GSF__LITERALS, 15, bits);
    gsf__huffman_lengths(d->distance_counts, GSF__DISTANCES, 15, distance_bits);
    const size_t packed = PACKED_HEAD + gsf__put_lengths(d, bits, GSF__LITERALS + GSF__DISTANCES, 0) +
                          gsf__token_bits(d, bits, distance_bits);
    if (size <= STORED_MOST && STORED_HEAD + 8 * size < packed) gsf__put_stored(d, last, size);
    else gsf__put_packed(d, last, bits);
    d->block_begin = end;
    memset(d->literal_counts, 0, sizeof d->literal_counts);
    memset(d->distance_counts, 0, sizeof d->distance_counts);
    d->token_count = 0;
}

static void gsf__put_token(gsf__deflater* d, size_t at, uint32_t length, uint32_t low) {
    if (d->token_count == GSF__LZ_TOKENS) gsf__put_block(d, 0, at);
    d->tokens[d->token_count++] = length << 16 | low;
    d->literal_counts[length ? gsf__length_class(length).code : low]++;
    if (length) d->distance_counts[gsf__distance_class(low).code]++;
}

static int32_t* gsf__lz_head(gsf__deflater* d, size_t at) {
    const unsigned char* p = d->data + at;
    const uint32_t three = (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16;
    return &d->head[(three * 0x9e3779b1u) >> 17];
}

static void gsf__lz_remember(gsf__deflater* d, size_t at) {
    if (d->size - at < GSF__LZ_SHORTEST) return;
    int32_t* head = gsf__lz_head(d, at);
    d->previous[at % GSF__LZ_WINDOW] = *head;
    *head = (int32_t)at;
}

// Length of the longest match among the GSF__LZ_TRIES latest candidates before `at`, 0 if none is longer than `best`.
static size_t gsf__lz_match(gsf__deflater* d, size_t at, size_t best, uint32_t* distance) {
    const size_t most = d->size - at < GSF__LZ_LONGEST ? d->size - at : (size_t)GSF__LZ_LONGEST;
    size_t found = 0;
    if (best >= most || most < GSF__LZ_SHORTEST) return 0;
    int32_t from = *gsf__lz_head(d, at);
    for (int tries = GSF__LZ_TRIES; tries > 0 && from >= 0 && at - (size_t)from < GSF__LZ_WINDOW; tries--) {
        const unsigned char *a = d->data + from, *b = d->data + at;
        if (a[best] == b[best]) {
            size_t n = 0;
            while (n < most && a[n] == b[n]) n++;
            if (n > best) {
                best = found = n;
                *distance = (uint32_t)(at - (size_t)from);
                if (n == most) break;
            }
        }
        from = d->previous[(size_t)from % GSF__LZ_WINDOW];
    }
    return found;
}

static gsf_result gsf__lz_compress(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_buffer* out) {
    if (size > (size_t)1 << 30)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %zu bytes to compress, more than 2^30", name, size);
    gsf__deflater* d = (gsf__deflater*)gsf_alloc_zeroed(ctx, 1, sizeof *d);
    if (!d) return GSF_ERROR_OUT_OF_MEMORY;
    d->ctx = ctx;
    d->out = out;
    d->data = (const unsigned char*)data;
    d->size = size;
    memset(d->head, 255, sizeof d->head);
    for (size_t at = 0; at < size && !out->failed;) {
        uint32_t distance = 0, ignored = 0;
        size_t length = gsf__lz_match(d, at, GSF__LZ_SHORTEST - 1, &distance);
        gsf__lz_remember(d, at);
        // Lazy matching: a literal here if the next byte starts a longer match.
        if (length && length < GSF__LZ_GOOD && gsf__lz_match(d, at + 1, length, &ignored)) length = 0;
        gsf__put_token(d, at, (uint32_t)length, length ? distance : d->data[at]);
        for (size_t i = 1; i < length; i++) gsf__lz_remember(d, at + i);
        at += length ? length : 1;
    }
    gsf__put_block(d, 1, size);
    gsf__put_bits(d, 0, 7); // flush the last, partial byte
    gsf_append_bytes(ctx, out, (const char*)d->buffer, d->used);
    gsf_free(ctx, d);
    return out->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

// ---- >>images ------------------------------------------------------------------

#ifndef GSF_NO_STB
#ifndef GSF_STB_IMAGE_INCLUDE
#define GSF_STB_IMAGE_INCLUDE <stb/stb_image.h>
#endif
#ifndef GSF_STB_IMAGE_WRITE_INCLUDE
#define GSF_STB_IMAGE_WRITE_INCLUDE <stb/stb_image_write.h>
#endif
#if defined(__GNUC__) || defined(__clang__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wconversion"
#pragma GCC diagnostic ignored "-Wsign-conversion"
#pragma GCC diagnostic ignored "-Wshadow"
#pragma GCC diagnostic ignored "-Wpedantic"
#pragma GCC diagnostic ignored "-Wmissing-field-initializers"
#if !defined(__clang__)
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif
#endif
#if defined(__clang__) // stb shifts bits out of signed integers by design
#pragma clang attribute push(__attribute__((no_sanitize("shift"))), apply_to = function)
#endif
// Private (static) copies of stb, which never clash with the host's. If this translation unit already includes
// stb, that copy is used.
#ifndef STBI_INCLUDE_STB_IMAGE_H
#define STB_IMAGE_IMPLEMENTATION
#define STB_IMAGE_STATIC
#define STBIDEF GSF__SHARED
#define STBI_ONLY_PNG
#define STBI_ONLY_JPEG
#define STBI_ONLY_BMP
#define STBI_ONLY_TGA
#define STBI_ONLY_PNM
#define STBI_NO_GIF
#define STBI_NO_STDIO
#ifdef __TINYC__ // no intrinsics
#define STBI_NO_SIMD
#endif
#define STBI_ASSERT(x) ((void)0) // damaged files trigger some of them
// Zeroed memory makes the pixels of damaged files deterministic: stb leaves parts unwritten, such as the tables of a scan or
// the end of a row.
#define STBI_MALLOC(size) calloc(1, size)
#define STBI_REALLOC_SIZED(p, old_size, size) gsf__stb_grow(p, old_size, size)
#define STBI_FREE(p) free(p)
static void* gsf__stb_grow(void* block, size_t old_size, size_t size) {
    char* grown = (char*)realloc(block, size);
    if (grown && size > old_size) memset(grown + old_size, 0, size - old_size);
    return grown;
}
#define stbi__unpremultiply_on_load_thread stbi_set_unpremultiply_on_load_thread // stb 2.27 defines it under the wrong name
#include GSF_STB_IMAGE_INCLUDE
#undef stbi__unpremultiply_on_load_thread
#undef STBI_MALLOC
#undef STBI_REALLOC_SIZED
#undef STBI_FREE
#undef STBI_ASSERT
#undef STB_IMAGE_IMPLEMENTATION
#endif
#ifndef INCLUDE_STB_IMAGE_WRITE_H
#define STB_IMAGE_WRITE_IMPLEMENTATION
#define STB_IMAGE_WRITE_STATIC
#define STBIWDEF GSF__SHARED
#include GSF_STB_IMAGE_WRITE_INCLUDE
#undef STB_IMAGE_WRITE_IMPLEMENTATION
#endif
#if defined(__clang__)
#pragma clang attribute pop
#endif
#if defined(__GNUC__) || defined(__clang__)
#pragma GCC diagnostic pop
#endif
#endif // GSF_NO_STB

GSF_API gsf_image gsf_wrap_image(void* data, gsf_dtype dtype, int64_t width, int64_t height, int32_t channels) {
    gsf_image image;
    memset(&image, 0, sizeof image);
    image.data = data;
    image.dtype = dtype;
    image.width = width;
    image.height = height;
    image.channels = channels;
    image.stride_c = (int64_t)gsf__dtype_size(dtype);
    image.stride_x = image.stride_c * channels;
    image.stride_y = image.stride_x * width;
    return image;
}

GSF_API gsf_result gsf_make_image(gsf_context* ctx, gsf_dtype dtype, int64_t width, int64_t height, int32_t channels,
                                  gsf_image* out) {
    memset(out, 0, sizeof *out);
    size_t count, bytes;
    if (width < 1 || height < 1 || channels < 1 || gsf__dtype_size(dtype) == 0 || (uint64_t)width > SIZE_MAX ||
        (uint64_t)height > SIZE_MAX || !gsf__mul_size((size_t)width, (size_t)height, &count) ||
        !gsf__mul_size(count, (size_t)channels, &count) || !gsf__mul_size(count, gsf__dtype_size(dtype), &bytes) ||
        (uint64_t)bytes >> 63)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "image: %lld x %lld with %d channels of type %d",
                        (long long)width, (long long)height, (int)channels, (int)dtype);
    void* data = gsf_alloc_zeroed(ctx, bytes, 1);
    if (!data) return GSF_ERROR_OUT_OF_MEMORY;
    *out = gsf_wrap_image(data, dtype, width, height, channels);
    out->owned = data;
    return GSF_OK;
}

GSF_API void gsf_destroy_image(gsf_context* ctx, gsf_image* image) {
    gsf_free(ctx, image->owned);
    memset(image, 0, sizeof *image);
}

static gsf_result gsf__check_image(gsf_context* ctx, const char* what, const gsf_image* image) {
    if (!image || !image->data) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: image without pixels", what);
    if (image->width < 1 || image->height < 1 || image->channels < 1 || gsf__dtype_size(image->dtype) == 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: image of %lld x %lld with %d channels of type %d", what,
                        (long long)image->width, (long long)image->height, (int)image->channels, (int)image->dtype);
    return GSF_OK;
}

// Parallel work on an image is split into chunks of rows of about 64k values, which depend on its size only.
typedef struct gsf__rows { int64_t begin, end; } gsf__rows;

static int64_t gsf__rows_per_chunk(const gsf_image* image) {
    const int64_t row = image->width * image->channels;
    return row > 0 && row < 65536 ? 65536 / row : 1;
}

static size_t gsf__row_chunks(const gsf_image* image) {
    const int64_t rows = gsf__rows_per_chunk(image);
    return (size_t)((image->height + rows - 1) / rows);
}

static gsf__rows gsf__chunk_rows(const gsf_image* image, size_t chunk) {
    const int64_t count = gsf__rows_per_chunk(image);
    gsf__rows rows;
    rows.begin = (int64_t)chunk * count;
    rows.end = rows.begin + count < image->height ? rows.begin + count : image->height;
    return rows;
}

// ---- conversion: one channel at a time, in runs of pixels, through double; integers are scaled to value / maximum

static void gsf__load_pixels(const char* p, int64_t stride, gsf_dtype dtype, size_t n, double* out) {
    switch (dtype) {
        case GSF_U8:
            for (size_t i = 0; i < n; i++, p += stride) out[i] = *(const unsigned char*)p / 255.0;
            break;
        case GSF_U16:
            for (size_t i = 0; i < n; i++, p += stride) { uint16_t v; memcpy(&v, p, sizeof v); out[i] = v / 65535.0; }
            break;
        case GSF_F16:
            for (size_t i = 0; i < n; i++, p += stride) {
                uint16_t v;
                memcpy(&v, p, sizeof v);
                out[i] = (double)gsf__half_to_float(v);
            }
            break;
        case GSF_F32:
            for (size_t i = 0; i < n; i++, p += stride) { float v; memcpy(&v, p, sizeof v); out[i] = (double)v; }
            break;
        case GSF_F64:
            for (size_t i = 0; i < n; i++, p += stride) memcpy(&out[i], p, sizeof(double));
            break;
    }
}

static double gsf__quantize(double scaled, double maximum) { // NaN becomes 0
    return scaled >= maximum ? maximum : scaled > 0.0 ? scaled : 0.0;
}

// in_float: the source has dtype f16 or f32, so x*255 + 0.5 is computed in float, as in torchvision.
static void gsf__store_pixels(char* p, int64_t stride, gsf_dtype dtype, size_t n, const double* in, int in_float) {
    switch (dtype) {
        case GSF_U8:
            for (size_t i = 0; i < n; i++, p += stride) {
                const float scaled = (float)in[i] * 255.0f;
                const double v = in_float ? (double)(scaled + 0.5f) : in[i] * 255.0 + 0.5;
                *(unsigned char*)p = (unsigned char)gsf__quantize(v, 255.0);
            }
            break;
        case GSF_U16:
            for (size_t i = 0; i < n; i++, p += stride) {
                const uint16_t v = (uint16_t)gsf__quantize(in[i] * 65535.0 + 0.5, 65535.0);
                memcpy(p, &v, sizeof v);
            }
            break;
        case GSF_F16:
            for (size_t i = 0; i < n; i++, p += stride) {
                const uint16_t v = gsf__float_to_half((float)in[i]);
                memcpy(p, &v, sizeof v);
            }
            break;
        case GSF_F32:
            for (size_t i = 0; i < n; i++, p += stride) { const float v = (float)in[i]; memcpy(p, &v, sizeof v); }
            break;
        case GSF_F64:
            for (size_t i = 0; i < n; i++, p += stride) memcpy(p, &in[i], sizeof(double));
            break;
    }
}

enum { GSF__CONVERT_RUN = 256 };

typedef struct gsf__convert_job {
    const gsf_image *src, *dst;
} gsf__convert_job;

static void gsf__convert_rows(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__convert_job* job = (const gsf__convert_job*)arg;
    const gsf_image *src = job->src, *dst = job->dst;
    const int in_float = src->dtype == GSF_F16 || src->dtype == GSF_F32;
    const gsf__rows rows = gsf__chunk_rows(dst, chunk);
    const int transfer = src->color_space != dst->color_space;
    const int by_table = src->dtype == GSF_U8 && dst->dtype == GSF_F32 && !transfer;
    float values[256]; // of bytes: a division for each pixel would take most of the time
    double run[GSF__CONVERT_RUN];
    for (int i = 0; by_table && i < 256; i++) values[i] = (float)(i / 255.0);
    for (int64_t y = rows.begin; y < rows.end; y++)
        for (int32_t c = 0; c < dst->channels; c++) {
            const int alpha = dst->channels % 2 == 0 && c == dst->channels - 1;
            const char* from =
                (const char*)src->data + y * src->stride_y + (src->channels == 1 ? 0 : c * src->stride_c);
            char* to = (char*)dst->data + y * dst->stride_y + c * dst->stride_c;
            for (int64_t x = 0; by_table && x < dst->width; x++, from += src->stride_x, to += dst->stride_x)
                memcpy(to, &values[*(const unsigned char*)from], sizeof(float));
            for (int64_t x = 0; !by_table && x < dst->width; x += GSF__CONVERT_RUN) {
                const int64_t left = dst->width - x;
                const size_t n = left < GSF__CONVERT_RUN ? (size_t)left : (size_t)GSF__CONVERT_RUN;
                gsf__load_pixels(from + x * src->stride_x, src->stride_x, src->dtype, n, run);
                if (transfer && !alpha) gsf__transfer_colors(run, n, dst->color_space);
                gsf__store_pixels(to + x * dst->stride_x, dst->stride_x, dst->dtype, n, run, in_float);
            }
        }
}

GSF_API gsf_result gsf_convert_image(gsf_context* ctx, const gsf_image* src, const gsf_image* dst) {
    GSF__TRY(gsf__check_image(ctx, "convert: source", src));
    GSF__TRY(gsf__check_image(ctx, "convert: destination", dst));
    if (src->width != dst->width || src->height != dst->height)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convert: sizes %lld x %lld and %lld x %lld differ",
                        (long long)src->width, (long long)src->height, (long long)dst->width, (long long)dst->height);
    if (src->channels != dst->channels && !(src->channels == 1 && dst->channels == 3) &&
        !(src->channels == 4 && dst->channels == 3))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convert: %d channels to %d", (int)src->channels,
                        (int)dst->channels);
    gsf__convert_job job;
    job.src = src;
    job.dst = dst;
    gsf__parallel_for(ctx, gsf__row_chunks(dst), gsf__convert_rows, &job);
    return GSF_OK;
}

// ---- files

enum { GSF__PIXELS_PER_BYTE = 8256, GSF__JPEG_QUALITY = 95 };

#if !defined(GSF_NO_STB) || defined(GSF_USE_OIIO)
// Refuses a file that claims more pixels than its size can hold, before memory is allocated for them. The densest format
// is 1-bit PNG, GSF__PIXELS_PER_BYTE: 8 pixels per byte, and DEFLATE compresses by 1032:1 at most.
static gsf_result gsf__check_image_claim(gsf_context* ctx, const char* name, int64_t width, int64_t height,
                                         size_t file_size, uint64_t pixels_per_byte) {
    if (width < 1 || height < 1 || width > (int64_t)1 << 28 || height > ((int64_t)1 << 28) / width ||
        (uint64_t)(width * height) / pixels_per_byte > file_size)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: a file of %zu bytes cannot hold %lld x %lld pixels", name,
                        file_size, (long long)width, (long long)height);
    return GSF_OK;
}

// Checks lengths and checksums of all chunks of a PNG, and that at most `most` bytes are image data. stb checks neither the
// checksums nor that the file is complete, and libpng prints its errors.
static gsf_result gsf__check_png(gsf_context* ctx, const char* name, const char* data, size_t size, uint64_t most) {
    uint64_t packed = 0;
    for (size_t at = 8;;) {
        if (size < at || size - at < 12)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: PNG is truncated (no IEND)", name, at);
        const unsigned char* head = (const unsigned char*)data + at;
        const size_t bytes = (size_t)head[0] << 24 | (size_t)head[1] << 16 | (size_t)head[2] << 8 | head[3];
        if (bytes > size - at - 12)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: PNG chunk of %zu bytes does not fit the file", name, at,
                            bytes);
        const unsigned char* sum = head + 8 + bytes;
        if (gsf__crc32(0, head + 4, bytes + 4) !=
            ((uint32_t)sum[0] << 24 | (uint32_t)sum[1] << 16 | (uint32_t)sum[2] << 8 | sum[3]))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: PNG checksum mismatch", name, at);
        if (memcmp(head + 4, "IEND", 4) == 0) return GSF_OK;
        if (memcmp(head + 4, "IDAT", 4) == 0) packed += bytes;
        if (packed > most)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: PNG has more data than its pixels need", name, at);
        at += 12 + bytes;
    }
}

#endif

#ifdef GSF_USE_OIIO
static gsf_result gsf__oiio_load(gsf_context* ctx, const char* name, const void* data, size_t size, int32_t channels,
                                 gsf_image* out);
static gsf_result gsf__oiio_query(gsf_context* ctx, const char* name, const void* data, size_t size, int64_t* width,
                                  int64_t* height, int32_t* channels);
static gsf_result gsf__oiio_encode(gsf_context* ctx, const char* name, const char* extension, const gsf_image* image,
                                   gsf_buffer* out);
#endif

#ifndef GSF_NO_STB

// Input of stb, from memory or a stdio file. `overrun` is set when stb reads past the end: stb itself continues with zeros,
// which would turn a truncated photo into a half-grey one.
typedef struct gsf__stb_source {
    const char* data;
    size_t size, at;
    FILE* file;         // instead of data
    const char* buffer; // stb's own, may be filled in part; reads into other memory must be complete, but stb does not check
    int overrun;
} gsf__stb_source;

static int gsf__stb_read(void* user, char* out, int size) {
    gsf__stb_source* s = (gsf__stb_source*)user;
    size_t got;
    if (s->file) {
        got = fread(out, 1, (size_t)size, s->file);
    } else {
        got = s->size - s->at < (size_t)size ? s->size - s->at : (size_t)size;
        memcpy(out, s->data + s->at, got);
    }
    s->at += got;
    if (!s->buffer) s->buffer = out; // stb fills its own buffer first
    if (got == 0 || (got < (size_t)size && out != s->buffer)) s->overrun = 1;
    return (int)got;
}

static void gsf__stb_skip(void* user, int n) {
    gsf__stb_source* s = (gsf__stb_source*)user;
    if (n < 0) return;
    if (s->file) {
        if (gsf__seek(s->file, n, SEEK_CUR) != 0) s->overrun = 1;
    } else if ((size_t)n > s->size - s->at) {
        s->overrun = 1;
        n = (int)(s->size - s->at);
    }
    s->at += (size_t)n;
}

static int gsf__stb_eof(void* user) {
    gsf__stb_source* s = (gsf__stb_source*)user;
    return s->file ? feof(s->file) != 0 : s->at >= s->size;
}

static stbi_io_callbacks gsf__stb_callbacks(void) {
    stbi_io_callbacks callbacks;
    callbacks.read = gsf__stb_read;
    callbacks.skip = gsf__stb_skip;
    callbacks.eof = gsf__stb_eof;
    return callbacks;
}

static gsf__stb_source gsf__stb_memory(const void* data, size_t size) {
    gsf__stb_source source;
    memset(&source, 0, sizeof source);
    source.data = (const char*)data;
    source.size = size;
    return source;
}

static gsf_result gsf__stb_fail(gsf_context* ctx, const char* name, const gsf__stb_source* source) {
    const char* reason = stbi_failure_reason();
    if (!reason) reason = "unknown reason";
    if (source->file && ferror(source->file)) return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", name, strerror(errno));
    if (strcmp(reason, "unknown image type") == 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: not an image format that this build can read", name);
    if (source->overrun) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: image is truncated", name, source->at);
    if (strcmp(reason, "outofmem") == 0) return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: out of memory", name);
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: image is malformed (%s)", name, source->at, reason);
}

static int gsf__source_byte(gsf__stb_source* source) {
    unsigned char c;
    return gsf__stb_read(source, (char*)&c, 1) == 1 ? c : -1;
}

static int gsf__source_u16(gsf__stb_source* source) { // big-endian
    const int high = gsf__source_byte(source), low = gsf__source_byte(source);
    return high < 0 || low < 0 ? -1 : high << 8 | low;
}

static void gsf__source_rewind(gsf__stb_source* source) {
    if (source->file) rewind(source->file);
    source->at = 0;
    source->buffer = NULL;
    source->overrun = 0;
}

typedef enum gsf__image_kind {
    GSF__IMAGE_OTHER = 0, GSF__IMAGE_PNG, GSF__IMAGE_BMP, GSF__IMAGE_JPEG, GSF__IMAGE_PNM, GSF__IMAGE_TGA
} gsf__image_kind;

// The format that stb would detect, from as few bytes as tell the formats apart; the source is left after them. A JPEG may
// begin with any number of fill bytes. Other formats that a host's copy of stb may read (GIF, PSD, PIC, HDR) are not
// mistaken for TGA, since only there the second byte is 0 or 1; they are never passed to stb.
static gsf__image_kind gsf__image_kind_of(gsf__stb_source* source) {
    const int first = gsf__source_byte(source);
    int second = gsf__source_byte(source);
    if (first == 0xff && second == 0xff)
        while (second == 0xff) second = gsf__source_byte(source);
    else if (second == 0 || second == 1)
        return GSF__IMAGE_TGA;
    switch (first) {
        case 0xff: return second == 0xd8 ? GSF__IMAGE_JPEG : GSF__IMAGE_OTHER;
        case 0x89: return second == 'P' ? GSF__IMAGE_PNG : GSF__IMAGE_OTHER;
        case 'B': return second == 'M' ? GSF__IMAGE_BMP : GSF__IMAGE_OTHER;
        case 'P': return second == '5' || second == '6' ? GSF__IMAGE_PNM : GSF__IMAGE_OTHER;
    }
    return GSF__IMAGE_OTHER;
}

// Checks Huffman tables and the number of scans of a JPEG; `at` is the position after its start marker. stb writes past its
// arrays if a table claims more than 256 symbols, and makes a pass over the whole image for each scan. Visits every
// position where stb may see a marker; truncation is left to the decoder, except inside a table.
static gsf_result gsf__check_jpeg(gsf_context* ctx, const char* name, const unsigned char* data, size_t size, size_t at) {
    enum { MOST_SCANS = 500 }; // encoders write about ten
    int scans = 0;
    while (at + 4 <= size) {
        const unsigned marker = data[at + 1];
        if (data[at] != 0xff || marker == 0xff || marker == 0 || (marker >= 0xd0 && marker <= 0xd7)) {
            at++; // padding or entropy-coded data
            continue;
        }
        if (marker == 0xd9) return GSF_OK; // end of image
        const size_t bytes = (size_t)data[at + 2] << 8 | data[at + 3], end = at + 2 + bytes;
        if (bytes < 2) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: JPEG segment of %zu bytes", name, at, bytes);
        if (marker == 0xda && ++scans > MOST_SCANS)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: JPEG of more than %d scans", name, at, (int)MOST_SCANS);
        if (marker == 0xc4)
            for (size_t table = at + 4; table < end;) {
                size_t symbols = 0;
                if (size < 17 || table > size - 17)
                    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: JPEG is truncated", name, size);
                for (size_t i = 1; i <= 16; i++) symbols += data[table + i];
                if (symbols > 256 || table + 17 + symbols > end)
                    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: JPEG table of %zu symbols", name, table, symbols);
                table += 17 + symbols;
            }
        at = end;
    }
    return GSF_OK;
}

// Size of a JPEG from its frame header; the source is positioned after the start marker. stb's own query would parse the
// unchecked tables before it.
static gsf_result gsf__jpeg_query(gsf_context* ctx, const char* name, gsf__stb_source* source, int64_t* width,
                                  int64_t* height, int32_t* channels) {
    for (;;) {
        int marker = gsf__source_byte(source);
        if (marker >= 0 && marker != 0xff) continue; // padding
        while (marker == 0xff) marker = gsf__source_byte(source);
        const int bytes = gsf__source_u16(source);
        if (marker < 0 || bytes < 0)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: image is truncated", name, source->at);
        if (bytes < 2 || marker == 0xd9 || marker == 0xda)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: JPEG without a frame header", name, source->at);
        if (marker < 0xc0 || marker > 0xcf || marker == 0xc4 || marker == 0xc8 || marker == 0xcc) {
            gsf__stb_skip(source, bytes - 2);
            continue;
        }
        (void)gsf__source_byte(source); // bits per sample
        const int h = gsf__source_u16(source), w = gsf__source_u16(source), c = gsf__source_byte(source);
        if (h < 1 || w < 1 || c < 1 || marker > 0xc2)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: JPEG of %d x %d, coding %d", name, source->at, w, h,
                            marker - 0xc0);
        *width = w;
        *height = h;
        *channels = c >= 3 ? 3 : 1;
        return GSF_OK;
    }
}

// Reads width, height and maximum value of a binary PNM; the source is positioned after the two letters. Returns 0 unless
// they are numbers of at most nine digits (stb would overflow an int).
static int gsf__pnm_head(gsf__stb_source* source, int32_t head[3]) {
    int c = gsf__source_byte(source);
    for (int i = 0; i < 3; i++) {
        while (c == ' ' || (c >= '\t' && c <= '\r') || c == '#') {
            if (c == '#') // a comment, up to the end of the line
                while (c >= 0 && c != '\n' && c != '\r') c = gsf__source_byte(source);
            else
                c = gsf__source_byte(source);
        }
        int digits = 0;
        for (head[i] = 0; c >= '0' && c <= '9' && digits < 9; digits++) {
            head[i] = head[i] * 10 + (c - '0');
            c = gsf__source_byte(source);
        }
        if (!digits || c < 0 || (c >= '0' && c <= '9')) return 0;
    }
    return 1;
}

static gsf_result gsf__pnm_query(gsf_context* ctx, const char* name, gsf__stb_source* source, int64_t* width,
                                 int64_t* height, int32_t* channels) {
    int32_t head[3];
    gsf__source_rewind(source);
    const int color = gsf__source_u16(source) == ('P' << 8 | '6');
    if (!gsf__pnm_head(source, head))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: PNM header is %s", name, source->at,
                        source->overrun ? "truncated" : "malformed");
    if (head[2] > 255) // stb 2.27 confuses 8-bit and 16-bit sizes there
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:0: 16-bit PNM", name);
    *width = head[0];
    *height = head[1];
    *channels = color ? 3 : 1;
    return GSF_OK;
}

static gsf_result gsf__stb_query(gsf_context* ctx, const char* name, gsf__stb_source* source, int64_t* width,
                                 int64_t* height, int32_t* channels) {
    const gsf__image_kind kind = gsf__image_kind_of(source);
    if (kind == GSF__IMAGE_JPEG) return gsf__jpeg_query(ctx, name, source, width, height, channels);
    if (kind == GSF__IMAGE_PNM) return gsf__pnm_query(ctx, name, source, width, height, channels);
    if (kind == GSF__IMAGE_OTHER && source->file && ferror(source->file))
        return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", name, strerror(errno));
    if (kind == GSF__IMAGE_OTHER)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: not an image format that this build can read", name);
    gsf__source_rewind(source);
    const stbi_io_callbacks callbacks = gsf__stb_callbacks();
    int w, h, c;
    if (!stbi_info_from_callbacks(&callbacks, source, &w, &h, &c)) return gsf__stb_fail(ctx, name, source);
    *width = w;
    *height = h;
    *channels = c;
    return GSF_OK;
}

// Appends a copy of the file with its palette padded with black to 256 entries. stb accepts all 256 indices but
// initialises only the entries in the file; the others would be uninitialised memory. Appends nothing if no copy is needed.
static void gsf__png_full_palette(gsf_context* ctx, const char* data, size_t size, gsf_buffer* out) {
    enum { FULL = 768 };
    static const char zeros[FULL] = {0}, head[8] = {0, 0, FULL >> 8, FULL & 255, 'P', 'L', 'T', 'E'};
    for (size_t at = 8; at + 12 <= size;) { // gsf__check_png has checked the lengths
        const unsigned char* p = (const unsigned char*)data + at;
        const size_t bytes = (size_t)p[0] << 24 | (size_t)p[1] << 16 | (size_t)p[2] << 8 | p[3];
        if (memcmp(p + 4, "IDAT", 4) == 0) return;
        if (memcmp(p + 4, "PLTE", 4) == 0) {
            if (bytes >= FULL || bytes % 3) return; // complete, or refused by stb
            gsf_append_bytes(ctx, out, data, at);
            gsf_append_bytes(ctx, out, head, sizeof head);
            gsf_append_bytes(ctx, out, data + at + 8, bytes);
            gsf_append_bytes(ctx, out, zeros, FULL - bytes);
            gsf_append_bytes(ctx, out, data + at + 8 + bytes, size - at - 8 - bytes); // stb skips the checksum
            return;
        }
        at += 12 + bytes;
    }
}

// The same for a BMP. With the old 12-byte header, stb counts four colours too few, as if the header had 24 bytes; 12 bytes
// more make up for that.
static gsf_result gsf__bmp_full_palette(gsf_context* ctx, const char* name, const char* data, size_t size,
                                        gsf_buffer* out) {
    static const char zeros[1024 + 12] = {0};
    if (size < 32) return GSF_OK; // stb reports that it is truncated
    const unsigned char* p = (const unsigned char*)data;
    const uint64_t offset = gsf__load_le(data + 10, 4), header = gsf__load_le(data + 14, 4), entry = header == 12 ? 3 : 4;
    const unsigned bits = header == 12 ? p[24] | (unsigned)p[25] << 8 : p[28] | (unsigned)p[29] << 8;
    if (bits >= 16 || header > 124) return GSF_OK;
    const uint64_t begin = 14 + header, colors = offset > begin ? (offset - begin) / entry : 0;
    if (colors < 1 || colors > 256 || offset > size)
        return gsf_fail(ctx, GSF_ERROR_FORMAT,
                        "%s:10: %u-bit BMP whose pixels begin at byte %llu, not after a palette", name,
                        bits, (unsigned long long)offset);
    const size_t old = header == 12 ? 12 : 0, full = (size_t)entry * 256, used = (size_t)(colors * entry);
    const uint64_t moved = begin + full + old;
    const char place[4] = {(char)(moved & 255), (char)(moved >> 8), 0, 0};
    gsf_append_bytes(ctx, out, data, 10);
    gsf_append_bytes(ctx, out, place, 4);
    gsf_append_bytes(ctx, out, data + 14, (size_t)header + used);
    gsf_append_bytes(ctx, out, zeros, full - used + old);
    gsf_append_bytes(ctx, out, data + (size_t)offset, size - (size_t)offset);
    return GSF_OK;
}

// stb allocates its scratch memory and decoded pixels with malloc, because its allocation hooks take no context; both are
// freed before this returns.
static gsf_result gsf__stb_load(gsf_context* ctx, const char* name, const void* data, size_t size, int32_t channels,
                                gsf_image* out) {
    gsf__stb_source source = gsf__stb_memory(data, size);
    int64_t width = 0, height = 0;
    int32_t file_channels = 0;
    GSF__TRY(gsf__stb_query(ctx, name, &source, &width, &height, &file_channels));
    gsf__source_rewind(&source);
    const gsf__image_kind kind = gsf__image_kind_of(&source);
    const uint64_t densest = kind == GSF__IMAGE_PNM   ? 1
                             : kind == GSF__IMAGE_BMP ? 8  // 1 bit per pixel
                             : kind == GSF__IMAGE_TGA ? 64 // a packet of two bytes repeats a pixel up to 128 times
                                                      : GSF__PIXELS_PER_BYTE;
    GSF__TRY(gsf__check_image_claim(ctx, name, width, height, size, densest));
    // stb inflates all image data before it checks the number of rows. The limit on the compressed data is twice the size of
    // uncompressed rows of four 16-bit channels.
    const uint64_t most = 65536 + 2 * (uint64_t)height * (8 * (uint64_t)width + 1);
    if (kind == GSF__IMAGE_PNG) GSF__TRY(gsf__check_png(ctx, name, (const char*)data, size, most));
    if (kind == GSF__IMAGE_JPEG) GSF__TRY(gsf__check_jpeg(ctx, name, (const unsigned char*)data, size, source.at));
    gsf__source_rewind(&source);
    gsf_buffer whole;
    memset(&whole, 0, sizeof whole);
    if (kind == GSF__IMAGE_BMP) GSF__TRY(gsf__bmp_full_palette(ctx, name, (const char*)data, size, &whole));
    if (kind == GSF__IMAGE_PNG) gsf__png_full_palette(ctx, (const char*)data, size, &whole);
    if (whole.failed) return GSF_ERROR_OUT_OF_MEMORY;
    if (whole.data) source = gsf__stb_memory(whole.data, whole.size);
    const stbi_io_callbacks callbacks = gsf__stb_callbacks();
    int w, h, c;
    stbi_uc* pixels = stbi_load_from_callbacks(&callbacks, &source, &w, &h, &c, channels);
    gsf_result result = pixels && !source.overrun ? GSF_OK : gsf__stb_fail(ctx, name, &source);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, w, h, channels ? channels : c, out);
    if (result == GSF_OK) memcpy(out->data, pixels, (size_t)out->stride_y * (size_t)h);
    stbi_image_free(pixels);
    gsf_destroy_buffer(ctx, &whole);
    return result;
}

#ifdef GSF_USE_OIIO
// Whether stb decodes this file even if OpenImageIO could: it gets all 8-bit files, so that their pixels are the same in all
// builds.
static int gsf__stb_reads(const void* data, size_t size) {
    gsf__stb_source source = gsf__stb_memory(data, size);
    const stbi_io_callbacks callbacks = gsf__stb_callbacks();
    const gsf__image_kind kind = gsf__image_kind_of(&source);
    int32_t head[3];
    int w, h, c;
    if (kind == GSF__IMAGE_JPEG || kind == GSF__IMAGE_OTHER) return kind == GSF__IMAGE_JPEG;
    if (kind == GSF__IMAGE_PNM) return gsf__pnm_head(&source, head) && head[2] <= 255;
    gsf__source_rewind(&source);
    if (!stbi_info_from_callbacks(&callbacks, &source, &w, &h, &c)) return 0;
    gsf__source_rewind(&source);
    return !stbi_is_16_bit_from_callbacks(&callbacks, &source);
}
#endif

static void gsf__stb_write(void* user, void* data, int size) {
    void** both = (void**)user; // context, buffer
    gsf_append_bytes((gsf_context*)both[0], (gsf_buffer*)both[1], (const char*)data, (size_t)size);
}

#endif // GSF_NO_STB

static gsf_result gsf__stb_inflate(gsf_context* ctx, const char* name, const void* data, size_t size, size_t body, void* out,
                                   size_t room) {
#ifdef GSF_NO_STB
    (void)data, (void)size, (void)body, (void)out, (void)room;
    return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: this build cannot read compressed files (GSF_NO_STB)", name);
#else
    if (size - body > (size_t)INT32_MAX || room > (size_t)INT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: %zu compressed bytes for %zu: at most 2^31-1 are read", name,
                        body, size - body, room);
    memset(out, 0, room); // stb 2.27 takes the two invalid distance codes for distance 0 and copies what `out` held before
    const int got = stbi_zlib_decode_noheader_buffer((char*)out, (int)room, (const char*)data + body, (int)(size - body));
    if (got < 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: compressed data is malformed, truncated or longer than %zu bytes",
                        name, body, room);
    if ((size_t)got != room)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: compressed data holds %d bytes, not %zu", name, body, got, room);
    return GSF_OK;
#endif
}

// The extension of a path with its dot, in lower case; "" if there is none or it is longer than 7 characters.
static void gsf__path_extension(const char* path, char out[8]) {
    const char* dot = strrchr(path, '.');
    size_t n = dot ? strlen(dot) : 0;
    if (n > 7) n = 0;
    for (size_t i = 0; i < n; i++) out[i] = (char)(dot[i] >= 'A' && dot[i] <= 'Z' ? dot[i] + 32 : dot[i]);
    out[n] = 0;
}

GSF_API gsf_result gsf_decode_image(gsf_context* ctx, const char* name, const void* data, size_t size,
                                    int32_t channels, gsf_image* out) {
    memset(out, 0, sizeof *out);
    if (channels != 0 && channels != 1 && channels != 3 && channels != 4)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %d channels wanted (0, 1, 3 or 4)", name, (int)channels);
    if (size == 0) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: file is empty", name);
#ifdef GSF_USE_OIIO
#ifdef GSF_NO_STB
    return gsf__oiio_load(ctx, name, data, size, channels, out);
#else
    if (!gsf__stb_reads(data, size)) return gsf__oiio_load(ctx, name, data, size, channels, out);
#endif
#endif
#ifndef GSF_NO_STB
    return gsf__stb_load(ctx, name, data, size, channels, out);
#elif !defined(GSF_USE_OIIO)
    (void)data;
    return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: this build cannot read images (GSF_NO_STB)", name);
#endif
}

GSF_API gsf_result gsf_load_image(gsf_context* ctx, const char* path, int32_t channels, gsf_image* out) {
    memset(out, 0, sizeof *out);
    void* data;
    size_t size;
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    const gsf_result result = gsf_decode_image(ctx, path, data, size, channels, out);
    gsf_free(ctx, data);
    return result;
}

GSF_API gsf_result gsf_query_image(gsf_context* ctx, const char* path, int64_t* width, int64_t* height,
                                   int32_t* channels) {
    *width = *height = 0;
    *channels = 0;
#ifndef GSF_NO_STB
    if (gsf__io_is_plain(ctx)) { // reads only the header
        gsf__stb_source source = gsf__stb_memory(NULL, 0);
        GSF__TRY(gsf__open_file(ctx, path, &source.file));
        const gsf_result result = gsf__stb_query(ctx, path, &source, width, height, channels);
        fclose(source.file);
#ifdef GSF_USE_OIIO
        if (result == GSF_OK) return GSF_OK;
#else
        return result;
#endif
    }
#endif
    void* data;
    size_t size;
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    gsf_result result;
#ifndef GSF_NO_STB
    gsf__stb_source source = gsf__stb_memory(data, size);
    result = gsf__stb_query(ctx, path, &source, width, height, channels);
#ifdef GSF_USE_OIIO
    if (result != GSF_OK) result = gsf__oiio_query(ctx, path, data, size, width, height, channels);
#endif
#elif defined(GSF_USE_OIIO)
    result = gsf__oiio_query(ctx, path, data, size, width, height, channels);
#else
    result = gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: this build cannot read images (GSF_NO_STB)", path);
#endif
    gsf_free(ctx, data);
    return result;
}

// ---- PNG encoder, 8 or 16 bits per channel

static int gsf__paeth(int left, int up, int corner) {
    const int estimate = left + up - corner;
    const int l = abs(estimate - left), u = abs(estimate - up), c = abs(estimate - corner);
    return l <= u && l <= c ? left : u <= c ? up : corner;
}

// Applies one of PNG's five filters to a row (`step`: bytes per pixel; `up`: the row above, zeros for the first row).
// Returns the sum of absolute differences: the filter with the smallest sum usually compresses best.
static uint64_t gsf__png_filter(int filter, const unsigned char* row, const unsigned char* up, size_t size, size_t step,
                                unsigned char* out) {
    uint64_t sum = 0;
    for (size_t i = 0; i < size; i++) {
        const int left = i >= step ? row[i - step] : 0, corner = i >= step ? up[i - step] : 0;
        const int guess = filter == 0   ? 0
                          : filter == 1 ? left
                          : filter == 2 ? up[i]
                          : filter == 3 ? (left + up[i]) / 2
                                        : gsf__paeth(left, up[i], corner);
        out[i] = (unsigned char)(row[i] - guess);
        sum += out[i] < 128 ? out[i] : 256u - out[i];
    }
    return sum;
}

// Filters all rows; the number of its filter precedes each. `room`: scratch for two rows.
static void gsf__png_filter_rows(const gsf_image* image, unsigned char* room, unsigned char* out) {
    const size_t size = (size_t)image->stride_y, step = (size_t)image->stride_x;
    unsigned char *zeros = room, *tried = room + size;
    memset(zeros, 0, size);
    for (int64_t y = 0; y < image->height; y++, out += size + 1) {
        const unsigned char* row = (const unsigned char*)image->data + y * image->stride_y;
        uint64_t best = UINT64_MAX;
        for (int filter = 0; filter < 5; filter++) {
            const uint64_t sum = gsf__png_filter(filter, row, y ? row - image->stride_y : zeros, size, step, tried);
            if (sum >= best) continue;
            best = sum;
            out[0] = (unsigned char)filter;
            memcpy(out + 1, tried, size);
        }
    }
}

static void gsf__store_be32(void* out, uint32_t value) {
    for (int i = 0; i < 4; i++) ((unsigned char*)out)[i] = (unsigned char)(value >> (24 - 8 * i) & 255u);
}

static uint32_t gsf__adler32(const unsigned char* data, size_t size) {
    uint32_t a = 1, b = 0;
    for (size_t i = 0; i < size;) {
        const size_t end = size - i < 5552 ? size : i + 5552; // as many bytes as b can sum in 32 bits
        for (; i < end; i++) b += a += data[i];
        a %= 65521u;
        b %= 65521u;
    }
    return b << 16 | a;
}

// Fills in the length of the chunk that began at `begin` and appends its checksum.
static void gsf__png_close(gsf_context* ctx, gsf_buffer* out, size_t begin) {
    char sum[4];
    if (out->failed) return;
    gsf__store_be32(out->data + begin, (uint32_t)(out->size - begin - 8));
    gsf__store_be32(sum, gsf__crc32(0, out->data + begin + 4, out->size - begin - 4));
    gsf_append_bytes(ctx, out, sum, sizeof sum);
}

// Appends a PNG file. `image`: packed, 1 to 4 channels; u8, or u16 with the bytes of each value in PNG's order.
static gsf_result gsf__png_append(gsf_context* ctx, const char* name, const gsf_image* image, gsf_buffer* out) {
    static const char kinds[5] = {0, 0, 4, 2, 6}; // PNG colour type by channel count
    char head[33] = "\x89PNG\r\n\x1a\n\0\0\0\0IHDR", sum[4];
    const size_t row = (size_t)image->stride_y, filtered_size = (row + 1) * (size_t)image->height;
    unsigned char* filtered = (unsigned char*)gsf_alloc(ctx, filtered_size + 2 * row, 1);
    if (!filtered) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__png_filter_rows(image, filtered + filtered_size, filtered);
    size_t begin = out->size + 8;
    gsf__store_be32(head + 16, (uint32_t)image->width);
    gsf__store_be32(head + 20, (uint32_t)image->height);
    head[24] = image->dtype == GSF_U16 ? 16 : 8;
    head[25] = kinds[image->channels];
    gsf_append_bytes(ctx, out, head, 8 + 8 + 13);
    gsf__png_close(ctx, out, begin);
    begin = out->size;
    gsf_append_bytes(ctx, out, "\0\0\0\0IDAT\x78\x5e", 10); // zlib header: 32 KiB window
    gsf_result result = gsf__deflate(ctx, name, filtered, filtered_size, out);
    gsf__store_be32(sum, gsf__adler32(filtered, filtered_size));
    gsf_append_bytes(ctx, out, sum, sizeof sum);
    gsf__png_close(ctx, out, begin);
    begin = out->size;
    gsf_append_bytes(ctx, out, "\0\0\0\0IEND", 8);
    gsf__png_close(ctx, out, begin);
    gsf_free(ctx, filtered);
    return result == GSF_OK && out->failed ? GSF_ERROR_OUT_OF_MEMORY : result;
}

static gsf_result gsf__jpeg_append(gsf_context* ctx, const char* name, const gsf_image* image, gsf_buffer* out) {
#ifdef GSF_NO_STB
    (void)image, (void)out;
    return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: this build cannot write JPEG (GSF_NO_STB)", name);
#else
    void* user[2]; // stb itself allocates nothing here: only `out` can run out of memory
    user[0] = ctx;
    user[1] = out;
    if (!stbi_write_jpg_to_func(gsf__stb_write, user, (int)image->width, (int)image->height, image->channels, image->data,
                                GSF__JPEG_QUALITY) ||
        out->failed)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: out of memory while encoding", name);
    return GSF_OK;
#endif
}

static void gsf__swap_u16(gsf_image* packed) { // to big-endian
    uint16_t* values = (uint16_t*)packed->data;
    const int64_t count = packed->width * packed->height * packed->channels;
    for (int64_t i = 0; i < count; i++) {
        unsigned char bytes[2];
        bytes[0] = (unsigned char)(values[i] >> 8);
        bytes[1] = (unsigned char)(values[i] & 255);
        memcpy(values + i, bytes, 2);
    }
}

static void gsf__exr_attribute(gsf_context* ctx, gsf_buffer* out, const char* name, const char* type, const void* data,
                               size_t size) {
    unsigned char length[4];
    gsf__store_le(length, size, 4);
    gsf_append_bytes(ctx, out, name, strlen(name) + 1);
    gsf_append_bytes(ctx, out, type, strlen(type) + 1);
    gsf_append_bytes(ctx, out, (const char*)length, 4);
    gsf_append_bytes(ctx, out, (const char*)data, size);
}

/* Appends an OpenEXR file of uncompressed scan lines. `image`: f16 or f32, packed, 1, 3 or 4 channels. Little-endian:
       magic 76 2f 31 01 | version 2 | attributes: name 0 type 0 size32 data | 0 | offset64 of each line |
       lines: y32 size32, then all values of one channel after another, channels sorted by name */
static gsf_result gsf__exr_append(gsf_context* ctx, const gsf_image* image, gsf_buffer* out) {
    static const char* const names[5] = {"", "Y", "", "BGR", "ABGR"};
    const char* name = names[image->channels];
    const size_t channels = (size_t)image->channels, size = image->dtype == GSF_F16 ? 2 : 4, begin = out->size;
    const size_t width = (size_t)image->width, height = (size_t)image->height, line = 8 + width * channels * size;
    unsigned char list[4 * 18 + 1], window[16], zeros[8], one[4];
    memset(list, 0, sizeof list);
    memset(window, 0, sizeof window);
    memset(zeros, 0, sizeof zeros);
    for (size_t c = 0; c < channels; c++) { // name 0 | 0 uint, 1 half, 2 float | linear | sampling in x and y
        list[18 * c] = (unsigned char)name[c];
        list[18 * c + 2] = size == 2 ? 1 : 2;
        list[18 * c + 10] = list[18 * c + 14] = 1;
    }
    gsf__store_le(window + 8, width - 1, 4);
    gsf__store_le(window + 12, height - 1, 4);
    gsf__store_le(one, 0x3f800000u, 4); // 1.0f
    gsf_append_bytes(ctx, out, "\x76\x2f\x31\x01\x02\0\0\0", 8);
    gsf__exr_attribute(ctx, out, "channels", "chlist", list, 18 * channels + 1);
    gsf__exr_attribute(ctx, out, "compression", "compression", zeros, 1);
    gsf__exr_attribute(ctx, out, "dataWindow", "box2i", window, 16);
    gsf__exr_attribute(ctx, out, "displayWindow", "box2i", window, 16);
    gsf__exr_attribute(ctx, out, "lineOrder", "lineOrder", zeros, 1);
    gsf__exr_attribute(ctx, out, "pixelAspectRatio", "float", one, 4);
    gsf__exr_attribute(ctx, out, "screenWindowCenter", "v2f", zeros, 8);
    gsf__exr_attribute(ctx, out, "screenWindowWidth", "float", one, 4);
    gsf_append_bytes(ctx, out, "", 1);
    const size_t table = out->size - begin + 8 * height;
    for (size_t y = 0; y < height; y++) {
        unsigned char offset[8];
        gsf__store_le(offset, table + y * line, 8);
        gsf_append_bytes(ctx, out, (const char*)offset, 8);
    }
    unsigned char* row = (unsigned char*)gsf_alloc(ctx, line, 1);
    if (!row) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t y = 0; y < height; y++) {
        const unsigned char* pixels = (const unsigned char*)image->data + y * (size_t)image->stride_y;
        gsf__store_le(row, y, 4);
        gsf__store_le(row + 4, line - 8, 4);
        for (size_t c = 0; c < channels; c++) {
            const size_t at = (channels - 1 - c) * size; // the names are those of the channels in reverse
            for (size_t x = 0; x < width; x++) {
                uint32_t bits = 0;
                uint16_t half = 0;
                if (size == 2) memcpy(&half, pixels + x * channels * size + at, 2);
                else memcpy(&bits, pixels + x * channels * size + at, 4);
                gsf__store_le(row + 8 + (c * width + x) * size, size == 2 ? half : bits, (int)size);
            }
        }
        gsf_append_bytes(ctx, out, (const char*)row, line);
    }
    gsf_free(ctx, row);
    return out->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

// Appends the encoded file to `out`, which is unchanged on error.
static gsf_result gsf__encode_image(gsf_context* ctx, const char* name, const gsf_image* image, const char* extension,
                                    gsf_buffer* out) {
    GSF__TRY(gsf__check_image(ctx, name, image));
    const int png = strcmp(extension, ".png") == 0, exr = strcmp(extension, ".exr") == 0;
    if (!png && !exr && strcmp(extension, ".jpg") != 0 && strcmp(extension, ".jpeg") != 0)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: this build writes .png, .jpg and .exr, not \"%s\"", name, extension);
    const int32_t channels = !png && !exr && image->channels == 4 ? 3 : image->channels;
    const gsf_dtype dtype = exr && image->dtype == GSF_F16   ? GSF_F16
                            : exr                            ? GSF_F32
                            : png && image->dtype == GSF_U16 ? GSF_U16
                                                             : GSF_U8;
    if (channels > 4 || (!png && channels == 2))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %d channels do not fit %s", name, (int)image->channels,
                        extension);
    const int64_t longest = png || exr ? 1 << 24 : 65535;
    if (image->width > longest || image->height > longest || image->width * image->height > (1 << 30) / (channels + 1))
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %lld x %lld pixels are too many for %s", name,
                        (long long)image->width, (long long)image->height, extension);
    const size_t before = out->size;
    gsf_image packed;
    GSF__TRY(gsf_make_image(ctx, dtype, image->width, image->height, channels, &packed));
    if (exr) packed.color_space = GSF_COLOR_LINEAR;
    gsf_result result = gsf_convert_image(ctx, image, &packed);
    if (result == GSF_OK && dtype == GSF_U16) gsf__swap_u16(&packed);
    if (result == GSF_OK)
        result = exr   ? gsf__exr_append(ctx, &packed, out)
                 : png ? gsf__png_append(ctx, name, &packed, out)
                       : gsf__jpeg_append(ctx, name, &packed, out);
    if (result != GSF_OK) out->size = before;
    gsf_destroy_image(ctx, &packed);
    return result;
}

GSF_API gsf_result gsf_encode_image(gsf_context* ctx, const gsf_image* image, const char* extension, gsf_buffer* out) {
    return gsf__encode_image(ctx, "encode", image, extension, out);
}

GSF_API gsf_result gsf_save_image(gsf_context* ctx, const char* path, const gsf_image* image) {
    char extension[8];
    gsf__path_extension(path, extension);
    gsf_buffer file;
    memset(&file, 0, sizeof file);
    gsf_result result;
#ifdef GSF_USE_OIIO
    GSF__TRY(gsf__check_image(ctx, path, image));
#ifdef GSF_NO_STB
    const int through_oiio = 1;
#else
    const int through_oiio = strcmp(extension, ".exr") == 0 || strcmp(extension, ".tif") == 0 ||
                             strcmp(extension, ".tiff") == 0 ||
                             (strcmp(extension, ".png") == 0 && image->dtype == GSF_U16);
#endif
    if (through_oiio) result = gsf__oiio_encode(ctx, path, extension, image, &file);
    else
#endif
        result = gsf__encode_image(ctx, path, image, extension, &file);
    if (result == GSF_OK) result = gsf_write_file(ctx, path, file.data, file.size);
    gsf_destroy_buffer(ctx, &file);
    return result;
}

// ---- >>resize ------------------------------------------------------------------
// PIL.Image.resize (Pillow's Resample.c). When shrinking, the filter is widened by the shrink factor. It is sampled at pixel
// centres; weights are normalised in double and, for u8, rounded to 22-bit fixed point. The first pass goes along x, the
// second along y, with u8 rounding in between. As in Pillow 13, y comes first if the height shrinks by more than twice as
// many pixels as the width. There is no pass along an axis whose size does not change.

enum { GSF__PIL_BITS = 32 - 8 - 2, GSF__RESIZE_RUN = 256 };

typedef struct gsf__resize_axis { // for each output position: taps first..first+count-1 with their weights
    int64_t in, out;
    size_t taps;           // weights stored per position
    int64_t *first, *count;
    double* weights;       // (out, taps)
    int32_t* fixed;        // (out, taps)
    void* owned;
} gsf__resize_axis;

static double gsf__sinc(double x) {
    const double pi = 3.14159265358979323846;
    return x == 0.0 ? 1.0 : gsf__sin_f64(x * pi) / (x * pi);
}

static double gsf__pil_filter(gsf_resize_filter filter, double x) {
    const double a = -0.5;
    if (filter == GSF_RESIZE_PIL_LANCZOS) return x >= -3.0 && x < 3.0 ? gsf__sinc(x) * gsf__sinc(x / 3.0) : 0.0;
    x = fabs(x);
    if (filter == GSF_RESIZE_PIL_BILINEAR) return x < 1.0 ? 1.0 - x : 0.0;
    if (x < 1.0) return ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0;
    return x < 2.0 ? (((x - 5.0) * x + 8.0) * x - 4.0) * a : 0.0;
}

static gsf_result gsf__make_pil_axis(gsf_context* ctx, gsf_resize_filter filter, int64_t in, int64_t out,
                                     gsf__resize_axis* axis) {
    memset(axis, 0, sizeof *axis);
    axis->in = in;
    axis->out = out;
    if (in == out) return GSF_OK;
    const double scale = (double)in / (double)out, widened = scale < 1.0 ? 1.0 : scale, narrow = 1.0 / widened;
    const double support = (filter == GSF_RESIZE_PIL_BILINEAR  ? 1.0
                            : filter == GSF_RESIZE_PIL_BICUBIC ? 2.0
                                                               : 3.0) *
                           widened;
    axis->taps = 2 * (size_t)ceil(support) + 1;
    size_t weights;
    if (!gsf__mul_size(axis->taps, (size_t)out, &weights) || weights > SIZE_MAX / 32)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "resize: %lld to %lld pixels", (long long)in, (long long)out);
    axis->owned = gsf_alloc(ctx, (size_t)out * 2 * sizeof(int64_t) + weights * (sizeof(double) + sizeof(int32_t)), 1);
    if (!axis->owned) return GSF_ERROR_OUT_OF_MEMORY;
    axis->first = (int64_t*)axis->owned;
    axis->count = axis->first + out;
    axis->weights = (double*)(void*)(axis->count + out);
    axis->fixed = (int32_t*)(void*)(axis->weights + weights);
    for (int64_t i = 0; i < out; i++) {
        const double center = ((double)i + 0.5) * scale;
        double *w = axis->weights + (size_t)i * axis->taps, sum = 0.0;
        const double low = center - support + 0.5, high = center + support + 0.5;
        const int64_t first = low > 0.0 ? (int64_t)low : 0, end = high < (double)in ? (int64_t)high : in;
        for (int64_t k = 0; k < end - first; k++) {
            w[k] = gsf__pil_filter(filter, ((double)(k + first) - center + 0.5) * narrow);
            sum += w[k];
        }
        axis->first[i] = first;
        axis->count[i] = end - first;
        for (int64_t k = 0; k < end - first; k++) {
            if (sum != 0.0) w[k] /= sum;
            const double scaled = w[k] * (1 << GSF__PIL_BITS);
            axis->fixed[(size_t)i * axis->taps + (size_t)k] = (int32_t)(w[k] < 0.0 ? scaled - 0.5 : scaled + 0.5);
        }
    }
    return GSF_OK;
}

static uint8_t gsf__pil_clip(int32_t sum) { // the sum includes the half that rounds it
    sum >>= GSF__PIL_BITS; // arithmetic shift
    return (uint8_t)(sum < 0 ? 0 : sum > 255 ? 255 : sum);
}

typedef struct gsf__resize_job {
    const gsf_image *src, *dst; // of this pass
    const gsf__resize_axis* axis;
} gsf__resize_job;

// The pass along x; the heights are the same.
static void gsf__resize_rows_x(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__resize_job* job = (const gsf__resize_job*)arg;
    const gsf_image *src = job->src, *dst = job->dst;
    const gsf__resize_axis* axis = job->axis;
    const gsf__rows rows = gsf__chunk_rows(dst, chunk);
    for (int64_t y = rows.begin; y < rows.end; y++)
        for (int64_t x = 0; x < dst->width; x++)
            for (int32_t c = 0; c < dst->channels; c++) {
                const char* from =
                    (const char*)src->data + y * src->stride_y + axis->first[x] * src->stride_x + c * src->stride_c;
                char* to = (char*)dst->data + y * dst->stride_y + x * dst->stride_x + c * dst->stride_c;
                const int64_t count = axis->count[x];
                if (src->dtype == GSF_U8) {
                    const int32_t* w = axis->fixed + (size_t)x * axis->taps;
                    int32_t sum = 1 << (GSF__PIL_BITS - 1);
                    for (int64_t k = 0; k < count; k++) sum += *(const uint8_t*)(from + k * src->stride_x) * w[k];
                    *(uint8_t*)to = gsf__pil_clip(sum);
                } else {
                    const double* w = axis->weights + (size_t)x * axis->taps;
                    double sum = 0.0;
                    for (int64_t k = 0; k < count; k++) {
                        float v;
                        memcpy(&v, from + k * src->stride_x, sizeof v);
                        sum += (double)v * w[k];
                    }
                    const float v = (float)sum;
                    memcpy(to, &v, sizeof v);
                }
            }
}

// The pass along y; the widths are the same. Works on runs of pixels, so that memory is read along rows.
static void gsf__resize_rows_y(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__resize_job* job = (const gsf__resize_job*)arg;
    const gsf_image *src = job->src, *dst = job->dst;
    const gsf__resize_axis* axis = job->axis;
    const gsf__rows rows = gsf__chunk_rows(dst, chunk);
    int32_t sums[GSF__RESIZE_RUN];
    double wide[GSF__RESIZE_RUN];
    for (int64_t y = rows.begin; y < rows.end; y++)
        for (int32_t c = 0; c < dst->channels; c++)
            for (int64_t x = 0; x < dst->width; x += GSF__RESIZE_RUN) {
                const int64_t left = dst->width - x, n = left < GSF__RESIZE_RUN ? left : (int64_t)GSF__RESIZE_RUN;
                const char* from =
                    (const char*)src->data + axis->first[y] * src->stride_y + x * src->stride_x + c * src->stride_c;
                char* to = (char*)dst->data + y * dst->stride_y + x * dst->stride_x + c * dst->stride_c;
                const int64_t sx = src->stride_x, dx = dst->stride_x;
                for (int64_t i = 0; i < n; i++) {
                    sums[i] = 1 << (GSF__PIL_BITS - 1);
                    wide[i] = 0.0;
                }
                for (int64_t k = 0; k < axis->count[y]; k++, from += src->stride_y) {
                    if (src->dtype == GSF_U8) {
                        const int32_t w = axis->fixed[(size_t)y * axis->taps + (size_t)k];
                        for (int64_t i = 0; i < n; i++) sums[i] += *(const uint8_t*)(from + i * sx) * w;
                    } else {
                        const double w = axis->weights[(size_t)y * axis->taps + (size_t)k];
                        for (int64_t i = 0; i < n; i++) {
                            float v;
                            memcpy(&v, from + i * sx, sizeof v);
                            wide[i] += (double)v * w;
                        }
                    }
                }
                for (int64_t i = 0; i < n; i++) {
                    const float v = (float)wide[i];
                    if (src->dtype == GSF_U8) *(uint8_t*)(to + i * dx) = gsf__pil_clip(sums[i]);
                    else memcpy(to + i * dx, &v, sizeof v);
                }
            }
}

static void gsf__resize_pass(gsf_context* ctx, gsf_chunk_fn body, const gsf_image* src, const gsf_image* dst,
                             const gsf__resize_axis* axis) {
    gsf__resize_job job;
    job.src = src;
    job.dst = dst;
    job.axis = axis;
    gsf__parallel_for(ctx, gsf__row_chunks(dst), body, &job);
}

static gsf_result gsf__resize_pil(gsf_context* ctx, const gsf_image* src, gsf_resize_filter filter,
                                  const gsf_image* dst) {
    gsf__resize_axis ax, ay;
    memset(&ay, 0, sizeof ay);
    gsf_image middle; // src at the new width or height
    memset(&middle, 0, sizeof middle);
    gsf_result result = gsf__make_pil_axis(ctx, filter, src->width, dst->width, &ax);
    if (result == GSF_OK) result = gsf__make_pil_axis(ctx, filter, src->height, dst->height, &ay);
    if (result != GSF_OK) goto cleanup;
    if (!ax.owned && !ay.owned) {
        result = gsf_convert_image(ctx, src, dst);
    } else if (!ay.owned) {
        gsf__resize_pass(ctx, gsf__resize_rows_x, src, dst, &ax);
    } else if (!ax.owned) {
        gsf__resize_pass(ctx, gsf__resize_rows_y, src, dst, &ay);
    } else {
        const int64_t less = src->height - dst->height;
        const int y_first = less > 0 && less > 2 * (src->width - dst->width);
        result = gsf_make_image(ctx, src->dtype, y_first ? src->width : dst->width, y_first ? dst->height : src->height,
                                src->channels, &middle);
        if (result != GSF_OK) goto cleanup;
        gsf__resize_pass(ctx, y_first ? gsf__resize_rows_y : gsf__resize_rows_x, src, &middle, y_first ? &ay : &ax);
        gsf__resize_pass(ctx, y_first ? gsf__resize_rows_x : gsf__resize_rows_y, &middle, dst, y_first ? &ax : &ay);
    }
cleanup:
    gsf_destroy_image(ctx, &middle);
    gsf_free(ctx, ax.owned);
    gsf_free(ctx, ay.owned);
    return result;
}

GSF_API gsf_result gsf_resize_image(gsf_context* ctx, const gsf_image* src, gsf_resize_filter filter,
                                    const gsf_image* dst) {
    GSF__TRY(gsf__check_image(ctx, "resize: source", src));
    GSF__TRY(gsf__check_image(ctx, "resize: destination", dst));
    if (src->dtype != dst->dtype || src->channels != dst->channels)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "resize: both images must have one dtype and channel count");
    if ((int)filter < 0 || filter > GSF_RESIZE_PIL_LANCZOS)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "resize: filter %d", (int)filter);
    if (src->dtype != GSF_F32 && src->dtype != GSF_U8)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "resize: dtype %d (u8 or f32)", (int)src->dtype);
    const int64_t longest = 1 << 24;
    if (src->width > longest || src->height > longest || dst->width > longest || dst->height > longest)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "resize: more than %lld pixels along a side", (long long)longest);
    return gsf__resize_pil(ctx, src, filter, dst);
}

// ---- >>metrics -----------------------------------------------------------------

typedef struct gsf__ssim_form { // of a value of SSIM
    int clamp;     // variances below 0 to 0
    int contrast;  // only the factor of contrast and structure
    int together;  // the variances of both images come as one
    double factor; // of variances and covariances
} gsf__ssim_form;

#define GSF__KERNELS "gsfixer.h" // they are at the end of this file
#define GSF__KERNELS_METRICS
#define GSF__KERNELS_AVX512
#define GSF__KERNELS_SIMD128
#include "gsfixer.h"
#undef GSF__KERNELS_METRICS

static gsf_result gsf__check_image_pair(gsf_context* ctx, const char* what, const gsf_image* a, const gsf_image* b,
                                        const gsf_image* mask) {
    GSF__TRY(gsf__check_image(ctx, what, a));
    GSF__TRY(gsf__check_image(ctx, what, b));
    if (a->width != b->width || a->height != b->height || a->channels != b->channels)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: images of %lld x %lld x %d and %lld x %lld x %d", what,
                        (long long)a->width, (long long)a->height, (int)a->channels, (long long)b->width,
                        (long long)b->height, (int)b->channels);
    if (!mask) return GSF_OK;
    GSF__TRY(gsf__check_image(ctx, what, mask));
    if (mask->dtype != GSF_U8 || mask->channels != 1 || mask->width != a->width || mask->height != a->height)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: the mask must be u8 with one channel, %lld x %lld", what,
                        (long long)a->width, (long long)a->height);
    return GSF_OK;
}

static int gsf__mask_at(const gsf_image* mask, int64_t x, int64_t y) {
    return !mask || *((const unsigned char*)mask->data + y * mask->stride_y + x * mask->stride_x) != 0;
}

typedef struct gsf__metric_sum { // of one chunk of rows
    double sum;
    uint64_t count;
} gsf__metric_sum;

// Adds up the chunks in order. what: for the error message.
static gsf_result gsf__metric_mean(gsf_context* ctx, const char* what, const gsf__metric_sum* sums, size_t chunks,
                                   double* mean) {
    double sum = 0.0;
    uint64_t count = 0;
    for (size_t i = 0; i < chunks; i++) {
        sum += sums[i].sum;
        count += sums[i].count;
    }
    if (count == 0) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "%s: the mask excludes all pixels", what);
    if (!isfinite(sum)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: an image holds a NaN or infinite value", what);
    *mean = sum / (double)count;
    return GSF_OK;
}

typedef struct gsf__pixel_job {
    const gsf_image *a, *b, *mask;
    int absolute;          // sums absolute differences instead of squares
    double (*bytes)(const uint8_t* a, const uint8_t* b, int64_t n, int absolute);
    gsf__metric_sum* sums; // one per chunk
} gsf__pixel_job;

static int gsf__is_packed_bytes(const gsf_image* image) { // along rows
    return image->dtype == GSF_U8 && image->stride_c == 1 && image->stride_x == image->channels;
}

static void gsf__pixel_rows(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__pixel_job* job = (const gsf__pixel_job*)arg;
    const gsf_image *a = job->a, *b = job->b;
    const gsf__rows rows = gsf__chunk_rows(a, chunk);
    if (!job->mask && gsf__is_packed_bytes(a) && gsf__is_packed_bytes(b)) {
        const int64_t n = a->width * a->channels;
        double all = 0.0;
        for (int64_t y = rows.begin; y < rows.end; y++)
            all += job->bytes((const uint8_t*)a->data + y * a->stride_y, (const uint8_t*)b->data + y * b->stride_y, n,
                              job->absolute);
        job->sums[chunk].sum = all / (job->absolute ? 255.0 : 255.0 * 255.0);
        job->sums[chunk].count = (uint64_t)(n * (rows.end - rows.begin));
        return;
    }
    double pa[GSF__CONVERT_RUN], pb[GSF__CONVERT_RUN], sum = 0.0;
    uint64_t count = 0;
    for (int64_t y = rows.begin; y < rows.end; y++)
        for (int32_t c = 0; c < a->channels; c++)
            for (int64_t x = 0; x < a->width; x += GSF__CONVERT_RUN) {
                const int64_t left = a->width - x, n = left < GSF__CONVERT_RUN ? left : (int64_t)GSF__CONVERT_RUN;
                gsf__load_pixels((const char*)a->data + y * a->stride_y + x * a->stride_x + c * a->stride_c,
                                 a->stride_x, a->dtype, (size_t)n, pa);
                gsf__load_pixels((const char*)b->data + y * b->stride_y + x * b->stride_x + c * b->stride_c,
                                 b->stride_x, b->dtype, (size_t)n, pb);
                for (int64_t i = 0; i < n; i++)
                    if (gsf__mask_at(job->mask, x + i, y)) {
                        sum += job->absolute ? fabs(pa[i] - pb[i]) : (pa[i] - pb[i]) * (pa[i] - pb[i]);
                        count++;
                    }
            }
    job->sums[chunk].sum = sum;
    job->sums[chunk].count = count;
}

// The mean of squared or absolute differences.
static gsf_result gsf__pixel_mean(gsf_context* ctx, const char* what, int absolute, const gsf_image* a, const gsf_image* b,
                                  const gsf_image* mask, double* out) {
    gsf__pixel_job job;
    job.a = a;
    job.b = b;
    job.mask = mask;
    job.absolute = absolute;
    job.bytes = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__difference_of_bytes);
    const size_t chunks = gsf__row_chunks(a);
    job.sums = (gsf__metric_sum*)gsf_alloc(ctx, chunks, sizeof *job.sums);
    if (!job.sums) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__parallel_for(ctx, chunks, gsf__pixel_rows, &job);
    const gsf_result result = gsf__metric_mean(ctx, what, job.sums, chunks, out);
    gsf_free(ctx, job.sums);
    return result;
}

static gsf_result gsf__psnr(gsf_context* ctx, const gsf_image* a, const gsf_image* b, const gsf_image* mask, double* out) {
    double mse = 0.0;
    GSF__TRY(gsf__pixel_mean(ctx, "psnr", 0, a, b, mask, &mse));
    *out = mse > 0.0 ? -10.0 * log10(mse) : (double)INFINITY;
    return GSF_OK;
}

/* SSIM with a separable window: each source row is blurred along x once (five quantities: a, b, aa, bb, ab; four where only
   the sum of both variances counts: a, b, aa + bb, ab) into a ring buffer with as many rows as the window; blurring the ring
   along y gives a row of the SSIM map. Each chunk of rows fills its own ring, so that chunks are independent. */

enum { GSF__SSIM_MAX_TAPS = 11, GSF__SSIM_ROWS = 48, GSF__SSIM_QUANTITIES = 5 };

typedef struct gsf__ssim_job {
    const gsf_image *a, *b, *mask;
    gsf_metric kind;
    int taps, radius;
    double weights[GSF__SSIM_MAX_TAPS];
    int64_t inset;           // map rows and columns left out at each border
    gsf__ssim_form form;
    size_t quantities;
    double bytes[256];       // values of 8 bits
    size_t chunks_per_channel;
    gsf__metric_sum* sums;   // one per (channel, chunk)
    double* scratch;         // per worker: padded source rows, ring, quantities of a map row
    size_t scratch_size;     // doubles per worker
    void (*square)(const double* a, const double* b, size_t n, double* aa, double* bb, double* ab);
    void (*blur)(double* out, const double* const* rows, const double* weights, int taps, size_t n);
    void (*value)(const gsf__ssim_form* form, const double* map, size_t pitch, size_t n, double* out);
} gsf__ssim_job;

static int gsf__ssim_as_torchmetrics(gsf_metric kind) {
    return kind == GSF_METRIC_SSIM_TORCHMETRICS || kind == GSF_METRIC_MS_SSIM_TORCHMETRICS;
}

static int64_t gsf__reflect(int64_t i, int64_t n) { return i < 0 ? -i : i >= n ? 2 * n - 2 - i : i; }

// Loads row y of a channel of an image.
static void gsf__ssim_load_row(const gsf__ssim_job* job, const gsf_image* image, int32_t channel, int64_t y, double* out) {
    const char* from = (const char*)image->data + y * image->stride_y + channel * image->stride_c;
    if (image->dtype != GSF_U8) {
        gsf__load_pixels(from, image->stride_x, image->dtype, (size_t)image->width, out);
        return;
    }
    for (int64_t x = 0; x < image->width; x++) out[x] = job->bytes[*(const unsigned char*)(from + x * image->stride_x)];
}

// Blurs row y of both images along x, into five rows of `out` that are `pitch` doubles apart.
// padded: scratch, 5 rows of width + 2 radius.
static void gsf__ssim_blur_row(const gsf__ssim_job* job, int32_t channel, int64_t y, double* padded, double* out,
                               size_t pitch) {
    const gsf_image *a = job->a, *b = job->b;
    const int64_t radius = job->radius;
    const size_t width = (size_t)a->width, wide = width + 2 * (size_t)radius;
    if (y < 0 || y >= a->height) {
        if (job->kind == GSF_METRIC_SSIM_3DGS) { // zero padding
            for (size_t q = 0; q < job->quantities; q++) memset(out + q * pitch, 0, width * sizeof(double));
            return;
        }
        y = gsf__reflect(y, a->height);
    }
    double *pa = padded, *pb = padded + wide;
    gsf__ssim_load_row(job, a, channel, y, pa + radius);
    gsf__ssim_load_row(job, b, channel, y, pb + radius);
    for (int64_t x = -radius; x < 0; x++) { // pad both sides with zeros or the reflection
        const int64_t right = a->width - 1 - x; // as far outside the right border as x is outside the left
        const int mirror = gsf__ssim_as_torchmetrics(job->kind);
        for (int i = 0; i < 2; i++) {
            double* p = (i ? pb : pa) + radius;
            p[x] = mirror ? p[-x] : 0.0;
            p[right] = mirror ? p[gsf__reflect(right, a->width)] : 0.0;
        }
    }
    double *paa = pb + wide, *pbb = job->form.together ? NULL : paa + wide;
    job->square(pa, pb, wide, paa, pbb, padded + (job->quantities - 1) * wide);
    const double* rows[GSF__SSIM_MAX_TAPS];
    for (size_t q = 0; q < job->quantities; q++) {
        for (int t = 0; t < job->taps; t++) rows[t] = padded + q * wide + t;
        job->blur(out + q * pitch, rows, job->weights, job->taps, width);
    }
}

// The sum over a row's pixels that the mask includes, in four sums.
static gsf__metric_sum gsf__ssim_sum_row(const gsf_image* mask, int64_t row, int64_t begin, int64_t end, const double* values) {
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    gsf__metric_sum all = {0.0, (uint64_t)(end - begin)};
    int64_t x = begin;
    for (; !mask && x + 4 <= end; x += 4) s0 += values[x], s1 += values[x + 1], s2 += values[x + 2], s3 += values[x + 3];
    for (; x < end; x++)
        if (!gsf__mask_at(mask, x, row)) all.count--;
        else if ((x - begin) % 4 == 0) s0 += values[x];
        else if ((x - begin) % 4 == 1) s1 += values[x];
        else if ((x - begin) % 4 == 2) s2 += values[x];
        else s3 += values[x];
    all.sum = (s0 + s1) + (s2 + s3);
    return all;
}

static void gsf__ssim_rows(void* arg, size_t chunk, int32_t worker) {
    const gsf__ssim_job* job = (const gsf__ssim_job*)arg;
    const int32_t channel = (int32_t)(chunk / job->chunks_per_channel);
    const int64_t last = job->a->height - job->inset, radius = job->radius;
    const int64_t first = job->inset + (int64_t)(chunk % job->chunks_per_channel) * GSF__SSIM_ROWS;
    const int64_t end = first + GSF__SSIM_ROWS < last ? first + GSF__SSIM_ROWS : last;
    const size_t width = (size_t)job->a->width, taps = (size_t)job->taps;
    double* padded = job->scratch + (size_t)worker * job->scratch_size;
    double* ring = padded + GSF__SSIM_QUANTITIES * (width + 2 * (size_t)radius); // (quantity, taps, width)
    double* map = ring + GSF__SSIM_QUANTITIES * taps * width;                     // (quantity, width)
    double sum = 0.0;
    uint64_t count = 0;
    for (int64_t y = first - radius; y < end + radius; y++) { // source rows; each completes map row y - radius
        const size_t slot = (size_t)(y - (first - radius)) % taps;
        gsf__ssim_blur_row(job, channel, y, padded, ring + slot * width, taps * width);
        const int64_t row = y - radius;
        if (row < first) continue;
        const double* rows[GSF__SSIM_MAX_TAPS];
        for (size_t q = 0; q < job->quantities; q++) {
            for (size_t t = 0; t < taps; t++) rows[t] = ring + (q * taps + (slot + 1 + t) % taps) * width;
            job->blur(map + q * width, rows, job->weights, job->taps, width);
        }
        job->value(&job->form, map, width, width, padded); // the source row is not needed any more
        const gsf__metric_sum of_row =
            gsf__ssim_sum_row(job->mask, row, job->inset, (int64_t)width - job->inset, padded);
        sum += of_row.sum;
        count += of_row.count;
    }
    job->sums[chunk].sum = sum;
    job->sums[chunk].count = count;
}

// Sums the SSIM map, or its contrast, over each channel's chunks of rows: job->sums, freed by the caller.
static gsf_result gsf__ssim_sum(gsf_context* ctx, gsf_metric kind, int contrast, const gsf_image* a, const gsf_image* b,
                                const gsf_image* mask, gsf__ssim_job* job) {
    // exp(-x^2 / (2 * 1.5^2)) / sum for x = 0..5. First row: the Inria 3DGS code rounds these taps to float32 and then their
    // products once more, so its window sums to 1 - 6.94e-8, which adds 6.94e-8 mu^2 to its variances. These are the rounded
    // taps, scaled to give that sum. Second row: in double, as torchmetrics computes them for double images.
    static const double gauss[2][6] = {{0.2660117139984044, 0.21300552710375625, 0.1093606870495029, 0.03600077318386591,
                                        0.007598758182733767, 0.0010283801202764127},
                                       {0.26601172486179436, 0.21300553771125369, 0.10936068950970002,
                                        0.036000772128430829, 0.007598758135239185, 0.0010283800844791101}};
    memset(job, 0, sizeof *job);
    job->a = a;
    job->b = b;
    job->mask = mask;
    job->kind = kind;
    job->form.clamp = gsf__ssim_as_torchmetrics(kind);
    job->form.contrast = contrast;
    job->form.together = !job->form.clamp; // variances that are clamped are needed one by one
    job->form.factor = kind == GSF_METRIC_SSIM_SKIMAGE ? 49.0 / 48.0 : 1.0; // unbiased covariance of 7 x 7 samples
    for (int i = 0; i < 256; i++) job->bytes[i] = i / 255.0;
    job->quantities = job->form.together ? 4 : 5;
    job->taps = kind == GSF_METRIC_SSIM_SKIMAGE ? 7 : 11;
    job->radius = job->taps / 2;
    const double* half = gauss[kind != GSF_METRIC_SSIM_3DGS];
    for (int t = 0; t < job->taps; t++)
        job->weights[t] = kind == GSF_METRIC_SSIM_SKIMAGE ? 1.0 / 7.0 : half[t < 5 ? 5 - t : t - 5];
    if (kind == GSF_METRIC_SSIM_SKIMAGE || kind == GSF_METRIC_MS_SSIM || contrast) job->inset = job->radius;
    job->square = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__ssim_square);
    job->blur = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__ssim_blur);
    job->value = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__ssim_value);
    job->chunks_per_channel = (size_t)((a->height - 2 * job->inset + GSF__SSIM_ROWS - 1) / GSF__SSIM_ROWS);
    size_t chunks = 0;
    if (!gsf__mul_size(job->chunks_per_channel, (size_t)a->channels, &chunks) ||
        !gsf__mul_size((size_t)a->width + 2 * (size_t)job->radius, GSF__SSIM_QUANTITIES * ((size_t)job->taps + 2),
                       &job->scratch_size))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "ssim: image too large");
    job->sums = (gsf__metric_sum*)gsf_alloc(ctx, chunks, sizeof *job->sums);
    job->scratch = (double*)gsf_alloc(ctx, job->scratch_size, (size_t)ctx->parallel.worker_count * sizeof(double));
    const gsf_result result = job->sums && job->scratch ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) gsf__parallel_for(ctx, chunks, gsf__ssim_rows, job);
    gsf_free(ctx, job->scratch);
    return result;
}

// MS-SSIM is the product over scales of mean contrasts, and at the last one of the mean SSIM, each to the power of its
// weight; means below 0 count as 0.

enum { GSF__SSIM_SCALES = 5 };

typedef struct gsf__halve_job {
    const gsf_image *src, *dst; // f32, packed
    int64_t left, top;          // 1: a line of zeros before the image
} gsf__halve_job;

static void gsf__halve_rows(void* arg, size_t chunk, int32_t worker) { // means of 2 x 2 pixels
    const gsf__halve_job* job = (const gsf__halve_job*)arg;
    const gsf_image *src = job->src, *dst = job->dst;
    const gsf__rows rows = gsf__chunk_rows(dst, chunk);
    const int64_t channels = dst->channels;
    (void)worker;
    for (int64_t y = rows.begin; y < rows.end; y++) {
        const int64_t v = 2 * y - job->top, pitch = src->width * channels;
        const float* from = (const float*)src->data;
        float* to = (float*)dst->data + y * dst->width * channels;
        int64_t at = v * pitch - job->left * channels; // of the first of four pixels
        for (int64_t x = 0; x < dst->width; x++, at += channels)
            for (int64_t c = 0; c < channels; c++, at++, to++) {
                const int above = v >= 0, left = x > 0 || !job->left; // are there
                double sum = above && left ? (double)from[at] : 0.0;
                if (above) sum += (double)from[at + channels];
                if (left) sum += (double)from[at + pitch];
                *to = (float)((sum + (double)from[at + pitch + channels]) / 4.0);
            }
    }
}

// Replaces a packed f32 image by one of half its size.
static gsf_result gsf__halve_image(gsf_context* ctx, int pad, gsf_image* image) {
    gsf__halve_job job;
    gsf_image half;
    job.left = pad ? image->width % 2 : 0;
    job.top = pad ? image->height % 2 : 0;
    GSF__TRY(gsf_make_image(ctx, GSF_F32, (image->width + job.left) / 2, (image->height + job.top) / 2, image->channels,
                            &half));
    job.src = image;
    job.dst = &half;
    gsf__parallel_for(ctx, gsf__row_chunks(&half), gsf__halve_rows, &job);
    gsf_destroy_image(ctx, image);
    *image = half;
    return GSF_OK;
}

// Multiplies the means of one scale into `products`: one per channel, or a single one for all.
static gsf_result gsf__ssim_scale(gsf_context* ctx, gsf_metric kind, int scale, const gsf_image* a, const gsf_image* b,
                                  double* products) {
    static const double weights[GSF__SSIM_SCALES] = {0.0448, 0.2856, 0.3001, 0.2363, 0.1333};
    gsf__ssim_job job;
    gsf_result result = gsf__ssim_sum(ctx, kind, scale + 1 < GSF__SSIM_SCALES, a, b, NULL, &job);
    const size_t groups = kind == GSF_METRIC_MS_SSIM ? (size_t)a->channels : 1;
    const size_t chunks = job.chunks_per_channel * (size_t)a->channels / groups;
    for (size_t i = 0; i < groups && result == GSF_OK; i++) {
        double mean = 0.0;
        result = gsf__metric_mean(ctx, "ms-ssim", job.sums + i * chunks, chunks, &mean);
        products[i] *= pow(mean > 0.0 ? mean : 0.0, weights[scale]);
    }
    gsf_free(ctx, job.sums);
    return result;
}

static gsf_result gsf__ms_ssim(gsf_context* ctx, gsf_metric kind, const gsf_image* a, const gsf_image* b, const gsf_image* mask,
                               double* out) {
    if (mask) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "ms-ssim: masks are not supported");
    gsf_image pair[2];
    const size_t groups = kind == GSF_METRIC_MS_SSIM ? (size_t)a->channels : 1;
    double sum = 0.0, *products = (double*)gsf_alloc(ctx, groups, sizeof(double));
    gsf_result result = products ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    memset(pair, 0, sizeof pair);
    for (size_t i = 0; products && i < groups; i++) products[i] = 1.0;
    for (int i = 0; i < 2 && result == GSF_OK; i++) {
        result = gsf_make_image(ctx, GSF_F32, a->width, a->height, a->channels, &pair[i]);
        pair[i].color_space = (i ? b : a)->color_space;
        if (result == GSF_OK) result = gsf_convert_image(ctx, i ? b : a, &pair[i]);
    }
    for (int scale = 0; scale < GSF__SSIM_SCALES && result == GSF_OK; scale++) {
        for (int i = 0; i < 2 && scale > 0 && result == GSF_OK; i++)
            result = gsf__halve_image(ctx, kind == GSF_METRIC_MS_SSIM, &pair[i]);
        if (result == GSF_OK) result = gsf__ssim_scale(ctx, kind, scale, &pair[0], &pair[1], products);
    }
    for (size_t i = 0; i < groups && result == GSF_OK; i++) sum += products[i];
    if (result == GSF_OK) *out = sum / (double)groups;
    gsf_destroy_image(ctx, &pair[0]);
    gsf_destroy_image(ctx, &pair[1]);
    gsf_free(ctx, products);
    return result;
}

static gsf_result gsf__ssim(gsf_context* ctx, gsf_metric kind, const gsf_image* a, const gsf_image* b, const gsf_image* mask,
                            double* out) {
    gsf__ssim_job job;
    gsf_result result = gsf__ssim_sum(ctx, kind, 0, a, b, mask, &job);
    if (result == GSF_OK)
        result = gsf__metric_mean(ctx, "ssim", job.sums, job.chunks_per_channel * (size_t)a->channels, out);
    gsf_free(ctx, job.sums);
    return result;
}

GSF_API gsf_result gsf_measure_image(gsf_context* ctx, gsf_metric metric, const gsf_image* a, const gsf_image* b,
                                     const gsf_image* mask, double* out) {
    static const int64_t least[] = {1, 1, 1, 6, 7, 161, 176}; // of a side, by metric
    if ((int)metric < 0 || (size_t)metric >= GSF__COUNT(least))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "metric %d is unknown", (int)metric);
    GSF__TRY(gsf__check_image_pair(ctx, "metric", a, b, mask));
    if (a->width < least[metric] || a->height < least[metric])
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "ssim: %lld x %lld is smaller than the window", (long long)a->width,
                        (long long)a->height);
    if (metric == GSF_METRIC_PSNR) return gsf__psnr(ctx, a, b, mask, out);
    if (metric == GSF_METRIC_DIFFERENCE) return gsf__pixel_mean(ctx, "difference", 1, a, b, mask, out);
    if (metric >= GSF_METRIC_MS_SSIM) return gsf__ms_ssim(ctx, metric, a, b, mask, out);
    return gsf__ssim(ctx, metric, a, b, mask, out);
}

// ---- >>cameras -----------------------------------------------------------------

GSF_API void gsf_get_camera_center(const gsf_camera* camera, double center[3]) {
    double c2w[16];
    gsf__mat4_rigid_inverse(camera->w2c, c2w);
    memcpy(center, c2w + 12, 3 * sizeof(double));
}

GSF_API void gsf_get_camera_c2w(const gsf_camera* camera, double c2w[16]) { gsf__mat4_rigid_inverse(camera->w2c, c2w); }
GSF_API void gsf_set_camera_c2w(gsf_camera* camera, const double c2w[16]) { gsf__mat4_rigid_inverse(c2w, camera->w2c); }

GSF_API int32_t gsf_project_point(const gsf_camera* camera, const double point[3], double* u, double* v,
                                  double* depth) {
    double p[3];
    gsf__camera_transform(camera, point, p);
    *depth = p[2];
    if (!(p[2] > 0.0)) return 0;
    *u = camera->fx * p[0] / p[2] + camera->cx;
    *v = camera->fy * p[1] / p[2] + camera->cy;
    return 1;
}

GSF_API gsf_camera gsf_resize_camera(const gsf_camera* camera, int32_t width, int32_t height) {
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
    const double det = m[0] * (m[5] * m[10] - m[9] * m[6]) - m[4] * (m[1] * m[10] - m[9] * m[2]) +
                       m[8] * (m[1] * m[6] - m[5] * m[2]);
    if (!(det > 0.0)) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "camera: w2c is a reflection");
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

static void gsf__append_values(gsf_context* ctx, gsf_buffer* text, const double* values, size_t count, const char* between) {
    for (size_t i = 0; i < count; i++) {
        if (i) gsf_append_text(ctx, text, "%s", between);
        gsf_append_json_number(ctx, text, values[i]);
    }
}

static gsf_result gsf__write_text(gsf_context* ctx, const char* path, gsf_buffer* text) { // and frees it
    const gsf_result result = text->failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, text->data, text->size);
    gsf_destroy_buffer(ctx, text);
    return result;
}

static void gsf__camera_file(const char* const* names, size_t i, char out[512]) {
    if (names && names[i]) snprintf(out, 512, "%s", names[i]);
    else snprintf(out, 512, "%05zu.png", i);
}

// Each frame has its own intrinsics. The matrix is row by row; OpenGL's axes are y up and z backward.
static gsf_result gsf__save_transforms(gsf_context* ctx, const char* path, const gsf_camera* cameras, const char* const* names,
                                       size_t count) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_append_text(ctx, &text, "{\"camera_model\":\"PINHOLE\",\"frames\":[");
    for (size_t i = 0; i < count; i++) {
        const gsf_camera* c = cameras + i;
        const double values[4] = {c->fx, c->fy, c->cx, c->cy};
        static const char* const keys[4] = {"fl_x", "fl_y", "cx", "cy"};
        double c2w[16], row[4];
        char name[512], file[540];
        gsf_get_camera_c2w(c, c2w);
        gsf__camera_file(names, i, name);
        snprintf(file, sizeof file, "images/%s", name);
        gsf_append_text(ctx, &text, "%s\n{\"file_path\":", i ? "," : "");
        gsf_append_json_string(ctx, &text, file);
        gsf_append_text(ctx, &text, ",\"w\":%d,\"h\":%d", (int)c->width, (int)c->height);
        for (int k = 0; k < 4; k++) {
            gsf_append_text(ctx, &text, ",\"%s\":", keys[k]);
            gsf_append_json_number(ctx, &text, values[k]);
        }
        gsf_append_text(ctx, &text, ",\"transform_matrix\":[");
        for (int r = 0; r < 4; r++) {
            for (int k = 0; k < 4; k++) row[k] = k == 1 || k == 2 ? 0.0 - c2w[4 * k + r] : c2w[4 * k + r];
            gsf_append_text(ctx, &text, r ? ",[" : "[");
            gsf__append_values(ctx, &text, row, 4, ",");
            gsf_append_text(ctx, &text, "]");
        }
        gsf_append_text(ctx, &text, "]}");
    }
    gsf_append_text(ctx, &text, "\n]}\n");
    return gsf__write_text(ctx, path, &text);
}

// `path` is that of images.txt. An image has two lines, of which the second, its points, is empty.
static gsf_result gsf__save_colmap_text(gsf_context* ctx, const char* path, const gsf_camera* cameras, const char* const* names,
                                        size_t count) {
    const size_t length = strlen(path) - strlen("images.txt");
    char* beside = (char*)gsf_alloc(ctx, length + 16, 1);
    gsf_buffer list, images, points;
    memset(&list, 0, sizeof list);
    memset(&images, 0, sizeof images);
    memset(&points, 0, sizeof points);
    if (!beside) return GSF_ERROR_OUT_OF_MEMORY;
    memcpy(beside, path, length);
    gsf_append_text(ctx, &list, "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY\n");
    gsf_append_text(ctx, &images, "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points\n");
    gsf_append_text(ctx, &points, "# POINT3D_ID X Y Z R G B ERROR TRACK\n");
    for (size_t i = 0, id = 0; i < count; i++) {
        const gsf_camera* c = cameras + i;
        double values[7];
        char name[512];
        if (!i || c->width != c[-1].width || c->height != c[-1].height || c->fx != c[-1].fx || c->fy != c[-1].fy ||
            c->cx != c[-1].cx || c->cy != c[-1].cy) { // another camera than before
            values[0] = c->fx, values[1] = c->fy, values[2] = c->cx, values[3] = c->cy;
            gsf_append_text(ctx, &list, "%zu PINHOLE %d %d ", ++id, (int)c->width, (int)c->height);
            gsf__append_values(ctx, &list, values, 4, " ");
            gsf_append_text(ctx, &list, "\n");
        }
        gsf__quat_of(c->w2c, values);
        memcpy(values + 4, c->w2c + 12, 3 * sizeof(double));
        gsf__camera_file(names, i, name);
        gsf_append_text(ctx, &images, "%zu ", i + 1);
        gsf__append_values(ctx, &images, values, 7, " ");
        gsf_append_text(ctx, &images, " %zu %s\n\n", id, name);
    }
    memcpy(beside + length, "cameras.txt", 12);
    gsf_result result = gsf__write_text(ctx, beside, &list);
    memcpy(beside + length, "points3D.txt", 13);
    if (result == GSF_OK) result = gsf__write_text(ctx, beside, &points);
    if (result == GSF_OK) result = gsf__write_text(ctx, path, &images);
    gsf_destroy_buffer(ctx, &points);
    gsf_destroy_buffer(ctx, &images);
    gsf_free(ctx, beside);
    return result;
}

static int gsf__is_named(const char* path, const char* name) { // by its last part
    const size_t length = strlen(path), size = strlen(name);
    return length >= size && strcmp(path + length - size, name) == 0 &&
           (length == size || path[length - size - 1] == '/' || path[length - size - 1] == '\\');
}

GSF_API gsf_result gsf_save_cameras(gsf_context* ctx, const char* path, const gsf_camera* cameras,
                                    const char* const* names, size_t count) {
    static const char* const keys[4] = {"fx", "fy", "cx", "cy"};
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < count && result == GSF_OK; i++) {
        result = gsf_check_camera(ctx, &cameras[i]);
        if (result != GSF_OK) return gsf_fail(ctx, result, "%s: camera %zu: %s", path, i, ctx->error);
    }
    if (gsf__is_named(path, "transforms.json")) return gsf__save_transforms(ctx, path, cameras, names, count);
    if (gsf__is_named(path, "images.txt")) return gsf__save_colmap_text(ctx, path, cameras, names, count);
    gsf_append_text(ctx, &text, "{\"cameras\":[");
    for (size_t i = 0; i < count; i++) {
        const gsf_camera* camera = &cameras[i];
        gsf_append_text(ctx, &text, "%s\n{", i ? "," : "");
        if (names && names[i]) {
            gsf_append_text(ctx, &text, "\"name\":");
            gsf_append_json_string(ctx, &text, names[i]);
            gsf_append_text(ctx, &text, ",");
        }
        gsf_append_text(ctx, &text, "\"w2c\":[");
        for (int k = 0; k < 16; k++) { // row-major
            if (k) gsf_append_bytes(ctx, &text, ",", 1);
            gsf_append_json_number(ctx, &text, camera->w2c[4 * (k % 4) + k / 4]);
        }
        gsf_append_bytes(ctx, &text, "]", 1);
        const double values[4] = {camera->fx, camera->fy, camera->cx, camera->cy};
        for (int k = 0; k < 4; k++) {
            gsf_append_text(ctx, &text, ",\"%s\":", keys[k]);
            gsf_append_json_number(ctx, &text, values[k]);
        }
        gsf_append_text(ctx, &text, ",\"width\":%d,\"height\":%d}", (int)camera->width, (int)camera->height);
    }
    gsf_append_text(ctx, &text, "\n]}\n");
    if (result == GSF_OK && text.failed) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) result = gsf_write_file(ctx, path, text.data, text.size);
    gsf_destroy_buffer(ctx, &text);
    return result;
}

static gsf_result gsf__camera_number(gsf_context* ctx, const gsf_json* json, const gsf_json_value* object,
                                     const char* key, double* out) {
    const gsf_json_value* value = gsf_find_json_member(json, object, key);
    if (!value || value->type != GSF_JSON_NUMBER)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: camera: expected a number \"%s\"", json->name,
                        (unsigned)(value ? value->offset : object->offset), key);
    *out = value->number;
    return GSF_OK;
}

static gsf_result gsf__camera_from_json(gsf_context* ctx, const gsf_json* json, const gsf_json_value* object,
                                        gsf_camera* camera) {
    const gsf_json_value* matrix = gsf_find_json_member(json, object, "w2c");
    int good = matrix && matrix->type == GSF_JSON_ARRAY && matrix->count == 16;
    uint32_t at = good ? matrix->child : 0;
    for (int k = 0; k < 16 && good; k++, at = json->values[at].next) {
        good = json->values[at].type == GSF_JSON_NUMBER;
        camera->w2c[4 * (k % 4) + k / 4] = json->values[at].number;
    }
    if (!good)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: camera: expected \"w2c\" with 16 numbers", json->name,
                        (unsigned)(matrix ? matrix->offset : object->offset));
    double width = 0.0, height = 0.0;
    GSF__TRY(gsf__camera_number(ctx, json, object, "fx", &camera->fx));
    GSF__TRY(gsf__camera_number(ctx, json, object, "fy", &camera->fy));
    GSF__TRY(gsf__camera_number(ctx, json, object, "cx", &camera->cx));
    GSF__TRY(gsf__camera_number(ctx, json, object, "cy", &camera->cy));
    GSF__TRY(gsf__camera_number(ctx, json, object, "width", &width));
    GSF__TRY(gsf__camera_number(ctx, json, object, "height", &height));
    if (!(width >= 1.0 && width <= 2147483647.0 && height >= 1.0 && height <= 2147483647.0) || floor(width) != width ||
        floor(height) != height)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: camera: image size %g x %g", json->name,
                        (unsigned)object->offset, width, height);
    camera->width = (int32_t)width;
    camera->height = (int32_t)height;
    if (gsf_check_camera(ctx, camera) != GSF_OK)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: %s", json->name, (unsigned)object->offset, ctx->error);
    return GSF_OK;
}

GSF_API gsf_result gsf_load_cameras(gsf_context* ctx, const char* path, gsf_camera** cameras, size_t* count) {
    *cameras = NULL;
    *count = 0;
    void* data;
    size_t size;
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    gsf_json json;
    gsf_result result = gsf_parse_json(ctx, path, (const char*)data, size, &json);
    gsf_free(ctx, data);
    GSF__TRY(result);
    const gsf_json_value* list = gsf_find_json_member(&json, &json.values[0], "cameras");
    gsf_camera* out = NULL;
    if (!list || list->type != GSF_JSON_ARRAY) {
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: expected an object with a list \"cameras\"", json.name,
                          (unsigned)(list ? list->offset : 0));
    } else {
        out = (gsf_camera*)gsf_alloc_zeroed(ctx, list->count ? list->count : 1, sizeof *out);
        if (!out) result = GSF_ERROR_OUT_OF_MEMORY;
        uint32_t at = list->child;
        for (size_t i = 0; i < list->count && result == GSF_OK; i++, at = json.values[at].next)
            result = gsf__camera_from_json(ctx, &json, &json.values[at], &out[i]);
    }
    if (result == GSF_OK) {
        *cameras = out;
        *count = list->count;
    } else {
        gsf_free(ctx, out);
    }
    gsf_destroy_json(ctx, &json);
    return result;
}

// ---- >>clips -------------------------------------------------------------------

typedef struct gsf__clip { // state of gsf_restore_clip
    const gsf_restorer* restorer;
    const gsf_restore_window* window;
    gsf_restorer_info limits;
    int32_t taken, shown;       // frames of the clip per part; frames passed to the restorer for them
    int32_t parts, width, height;
    gsf_image *color, *depth, *alpha, *out_color, *out_confidence; // (shown) each: one part
    gsf_camera* cameras;
    int32_t* reference_index;
    float* weight;              // (frame_count) sum of blend weights of each frame so far
    int32_t begin;              // first frame of the current part
    gsf_image carried[GSF__CARRIED_IMAGES]; // resized, of the last call of gsf__clip_carry
} gsf__clip;

// Spreads `from` indices evenly over 0..to-1 and returns where index i goes, rounded.
static int32_t gsf__clip_spread(int64_t i, int64_t from, int64_t to) {
    return from > 1 ? (int32_t)((2 * i * (to - 1) + (from - 1)) / (2 * (from - 1))) : 0;
}

static void gsf__clip_plan_length(gsf__clip* c) {
    const gsf_restorer_info* l = &c->limits;
    const int32_t frames = c->window->frame_count, most = l->frame_count_max;
    const int32_t least = l->frame_count_min > 0 ? l->frame_count_min : 1;
    const int32_t step = l->frame_count_step > 1 ? l->frame_count_step : 1;
    c->taken = frames;
    c->shown = frames <= least ? least : least + (frames - least + step - 1) / step * step; // rounded up to a legal count
    c->parts = 1;
    if (most <= 0 || c->shown <= most) return;
    c->taken = c->shown = gsf__legal_count(l->frame_count > 0 ? l->frame_count : most, least, most, step);
    const int32_t overlap = c->taken > 5 ? c->taken / 6 : c->taken > 1;
    if (frames > c->taken) c->parts = 1 + (frames - overlap - 1) / (c->taken - overlap);
    else c->taken = frames; // only if frame_count_min > frame_count_max
}

static gsf_result gsf__clip_plan_size(gsf_context* ctx, gsf__clip* c) {
    const gsf_restorer_info* l = &c->limits;
    const gsf_image* first = &c->window->color[0];
    const double width = (double)first->width, height = (double)first->height;
    if (first->width > 65536 || first->height > 65536)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "clip: frames of %lld x %lld", (long long)first->width,
                        (long long)first->height);
    if (l->squash) {
        c->width = gsf__legal_side(l->width, l->width_multiple, l->width_max);
        c->height = gsf__legal_side(l->height, l->height_multiple, l->height_max);
        return GSF_OK;
    }
    double scale = 1.0;
    if (l->width_max > 0 && width > l->width_max) scale = l->width_max / width;
    if (l->height_max > 0 && height * scale > l->height_max) scale = l->height_max / height;
    c->width = gsf__legal_side(width * scale, l->width_multiple, l->width_max);
    c->height = gsf__legal_side(height * scale, l->height_multiple, l->height_max);
    if (fabs(c->width - width * scale) <= 0.5 + 0.5 * l->width_multiple &&
        fabs(c->height - height * scale) <= 0.5 + 0.5 * l->height_multiple)
        return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "clip: frames of %g x %g; the restorer needs square pixels and %d x %d",
                    width, height, (int)c->width, (int)c->height);
}

// Nearest-neighbour resize, for depths: an interpolated depth at an edge would lie on neither surface.
static void gsf__clip_pick(const gsf_image* from, const gsf_image* to) {
    for (int64_t y = 0; y < to->height; y++)
        for (int64_t x = 0; x < to->width; x++)
            for (int64_t k = 0; k < to->channels; k++) {
                const char* p = (const char*)from->data + (2 * y + 1) * from->height / (2 * to->height) * from->stride_y +
                                (2 * x + 1) * from->width / (2 * to->width) * from->stride_x + k * from->stride_c;
                memcpy((char*)to->data + y * to->stride_y + x * to->stride_x + k * to->stride_c, p, sizeof(float));
            }
}

enum { GSF__CLIP_FLOATS, GSF__CLIP_BYTES, GSF__CLIP_NEAREST }; // how to resize: BYTES in u8, as PIL resizes photos

// Resizes `from` into a new image *to. If the size is already right, *to is a view of `from`.
static gsf_result gsf__clip_fit(gsf_context* ctx, const gsf_image* from, int64_t width, int64_t height, int how,
                                gsf_image* to) {
    gsf_image bytes[2];
    memset(bytes, 0, sizeof bytes);
    if (from->width == width && from->height == height) {
        *to = *from;
        to->owned = NULL;
        return GSF_OK;
    }
    GSF__TRY(gsf_make_image(ctx, GSF_F32, width, height, from->channels, to));
    if (how == GSF__CLIP_NEAREST) {
        gsf__clip_pick(from, to);
        return GSF_OK;
    }
    if (how == GSF__CLIP_BYTES) {
        gsf_result result = gsf_make_image(ctx, GSF_U8, from->width, from->height, from->channels, &bytes[0]);
        if (result == GSF_OK) result = gsf_convert_image(ctx, from, &bytes[0]);
        if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, width, height, from->channels, &bytes[1]);
        if (result == GSF_OK) result = gsf_resize_image(ctx, &bytes[0], GSF_RESIZE_PIL_BICUBIC, &bytes[1]);
        if (result == GSF_OK) result = gsf_convert_image(ctx, &bytes[1], to);
        for (int i = 0; i < 2; i++) gsf_destroy_image(ctx, &bytes[i]);
        return result;
    }
    GSF__TRY(gsf_resize_image(ctx, from, GSF_RESIZE_PIL_BICUBIC, to));
    float* v = (float*)to->data; // bicubic overshoots at edges
    for (int64_t i = 0; i < width * height * from->channels; i++) v[i] = v[i] >= 1.0f ? 1.0f : v[i] > 0.0f ? v[i] : 0.0f;
    return GSF_OK;
}

static void gsf__clip_drop_frames(gsf_context* ctx, gsf__clip* c) {
    gsf_image* const sets[] = {c->color, c->depth, c->alpha, c->out_color, c->out_confidence};
    for (size_t s = 0; s < GSF__COUNT(sets); s++)
        for (int32_t i = 0; sets[s] && i < c->shown; i++) {
            if (sets[s][i].owned) gsf_destroy_image(ctx, &sets[s][i]);
            memset(&sets[s][i], 0, sizeof sets[s][i]);
        }
}

// Prepares the restorer's frames for the part that starts at frame `begin` of the clip.
static gsf_result gsf__clip_take(gsf_context* ctx, gsf__clip* c, int32_t begin) {
    const gsf_restore_window* w = c->window;
    for (int32_t i = 0; i < c->shown; i++) {
        const int32_t at = begin + gsf__clip_spread(i, c->shown, c->taken);
        GSF__TRY(gsf__clip_fit(ctx, &w->color[at], c->width, c->height, GSF__CLIP_BYTES, &c->color[i]));
        if (w->depth) GSF__TRY(gsf__clip_fit(ctx, &w->depth[at], c->width, c->height, GSF__CLIP_NEAREST, &c->depth[i]));
        if (w->alpha) GSF__TRY(gsf__clip_fit(ctx, &w->alpha[at], c->width, c->height, GSF__CLIP_FLOATS, &c->alpha[i]));
        if (w->cameras) c->cameras[i] = gsf_resize_camera(&w->cameras[at], c->width, c->height);
        c->reference_index[i] = w->reference_index ? w->reference_index[at] : -1;
        GSF__TRY(gsf_make_image(ctx, GSF_F32, c->width, c->height, 3, &c->out_color[i]));
        GSF__TRY(gsf_make_image(ctx, GSF_F32, c->width, c->height, 1, &c->out_confidence[i]));
    }
    return GSF_OK;
}

// *to = mean of *to, with weight `before`, and *from, with weight `weight`.
static void gsf__clip_blend(const gsf_image* from, float weight, float before, const gsf_image* to) {
    for (int64_t y = 0; y < to->height; y++)
        for (int64_t x = 0; x < to->width; x++)
            for (int64_t k = 0; k < to->channels; k++) {
                char* out = (char*)to->data + y * to->stride_y + x * to->stride_x + k * to->stride_c;
                float a, b;
                memcpy(&b, (const char*)from->data + y * from->stride_y + x * from->stride_x + k * from->stride_c, sizeof b);
                memcpy(&a, out, sizeof a);
                if (before > 0.0f) b = (a * before + b * weight) / (before + weight);
                memcpy(out, &b, sizeof b);
            }
}

// Blends the restored part into the clip's output frames. Weights decrease linearly towards both ends of a part, which
// cross-fades parts where they overlap.
static gsf_result gsf__clip_give(gsf_context* ctx, gsf__clip* c, int32_t begin) {
    for (int32_t i = 0; i < c->taken; i++) {
        const int32_t at = begin + i, shown = gsf__clip_spread(i, c->taken, c->shown);
        const float weight = (float)(i + 1 < c->taken - i ? i + 1 : c->taken - i);
        const gsf_image* const to[2] = {&c->window->out_color[at], &c->window->out_confidence[at]};
        const gsf_image* const from[2] = {&c->out_color[shown], &c->out_confidence[shown]};
        for (int k = 0; k < 2; k++) {
            gsf_image fitted;
            memset(&fitted, 0, sizeof fitted);
            const gsf_result result = gsf__clip_fit(ctx, from[k], to[k]->width, to[k]->height, GSF__CLIP_FLOATS, &fitted);
            if (result == GSF_OK) gsf__clip_blend(&fitted, weight, c->weight[at], to[k]);
            if (fitted.owned) gsf_destroy_image(ctx, &fitted);
            GSF__TRY(result);
        }
        c->weight[at] += weight;
    }
    return GSF_OK;
}

// carry_fn of a part: that of the clip, at the size of the part's frames. Nearest neighbours, since a pixel between two
// surfaces, or between something and nothing, would show neither.
static gsf_result gsf__clip_carry(void* user, gsf_context* ctx, int32_t frame, int32_t slot, gsf_carried* out) {
    gsf__clip* c = (gsf__clip*)user;
    gsf_image* images[GSF__CARRIED_IMAGES];
    int32_t channels[GSF__CARRIED_IMAGES];
    if (frame < 0 || frame >= c->shown)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "clip: frame %d of %d is to be carried", (int)frame, (int)c->shown);
    const int32_t at = c->begin + gsf__clip_spread(frame, c->shown, c->taken);
    GSF__TRY(c->window->carry_fn(c->window->carry_user, ctx, at, slot, out));
    gsf__list_carried(out, images, channels);
    for (int k = 0; k < GSF__CARRIED_IMAGES; k++) {
        gsf_image* kept = c->carried + k;
        if (!kept->data) GSF__TRY(gsf_make_image(ctx, GSF_F32, c->width, c->height, channels[k], kept));
        gsf__clip_pick(images[k], kept);
        *images[k] = *kept;
        images[k]->owned = NULL;
    }
    return GSF_OK;
}

static gsf_result gsf__clip_part(gsf_context* ctx, gsf__clip* c, int32_t part) {
    gsf_restore_window w = *c->window;
    const int32_t begin = gsf__clip_spread(part, c->parts, c->window->frame_count - c->taken + 1);
    c->begin = begin;
    GSF__TRY(gsf__clip_take(ctx, c, begin));
    if (w.carry_fn) {
        w.carry_fn = gsf__clip_carry;
        w.carry_user = c;
    }
    w.frame_count = c->shown;
    w.color = c->color;
    w.depth = w.depth ? c->depth : NULL;
    w.alpha = w.alpha ? c->alpha : NULL;
    w.cameras = w.cameras ? c->cameras : NULL;
    w.reference_index = c->reference_index;
    w.seed += (uint64_t)part;
    w.part = part;
    w.out_color = c->out_color;
    w.out_confidence = c->out_confidence;
    GSF__TRY(c->restorer->restore_fn(c->restorer->user, ctx, &w));
    return gsf__clip_give(ctx, c, begin);
}

GSF_API void gsf_destroy_restorer(gsf_context* ctx, gsf_restorer* restorer) {
    if (!restorer) return;
    const int whole = restorer->struct_size >= sizeof *restorer;
    if (whole && restorer->destroy_fn) restorer->destroy_fn(restorer->user, ctx);
    memset(restorer, 0, whole ? sizeof *restorer : restorer->struct_size);
}

GSF_API gsf_result gsf_restore_clip(gsf_context* ctx, const gsf_restorer* restorer, const gsf_restore_window* window) {
    gsf__clip c;
    gsf_restore_window complete; // with the fields that an older host's window lacks
    if (window->struct_size < GSF__WINDOW_BYTES || window->frame_count < 1 || !window->color || !window->out_color ||
        !window->out_confidence)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "clip: no frames, or struct_size is missing");
    memset(&complete, 0, sizeof complete);
    memcpy(&complete, window, window->struct_size < sizeof complete ? (size_t)GSF__WINDOW_BYTES : sizeof complete);
    complete.struct_size = sizeof complete;
    window = &complete;
    memset(&c, 0, sizeof c);
    c.restorer = restorer;
    c.window = window;
    c.limits.struct_size = sizeof c.limits;
    GSF__TRY(restorer->query_fn(restorer->user, ctx, window->frame_count, (int32_t)window->color[0].width,
                                (int32_t)window->color[0].height, &c.limits));
    gsf__clip_plan_length(&c);
    GSF__TRY(gsf__clip_plan_size(ctx, &c));
    if (c.parts == 1 && c.shown == window->frame_count && c.width == window->color[0].width &&
        c.height == window->color[0].height)
        return restorer->restore_fn(restorer->user, ctx, window);
    const size_t shown = (size_t)c.shown;
    c.color = (gsf_image*)gsf_alloc_zeroed(ctx, 5 * shown, sizeof *c.color);
    c.cameras = (gsf_camera*)gsf_alloc_zeroed(ctx, shown, sizeof *c.cameras);
    c.reference_index = (int32_t*)gsf_alloc_zeroed(ctx, shown, sizeof *c.reference_index);
    c.weight = (float*)gsf_alloc_zeroed(ctx, (size_t)window->frame_count, sizeof *c.weight);
    gsf_result result = c.color && c.cameras && c.reference_index && c.weight ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (c.color) {
        c.depth = c.color + shown;
        c.alpha = c.depth + shown;
        c.out_color = c.alpha + shown;
        c.out_confidence = c.out_color + shown;
    }
    for (int32_t part = 0; part < c.parts && result == GSF_OK; part++) {
        result = gsf__clip_part(ctx, &c, part);
        gsf__clip_drop_frames(ctx, &c);
    }
    for (int k = 0; k < GSF__CARRIED_IMAGES; k++) gsf_destroy_image(ctx, &c.carried[k]);
    gsf_free(ctx, c.color);
    gsf_free(ctx, c.cameras);
    gsf_free(ctx, c.reference_index);
    gsf_free(ctx, c.weight);
    return result;
}

// ---- >>oiio --------------------------------------------------------------------
// Files are decoded from and encoded to memory, so that the io hook and the atomic write also cover these formats.
// OpenImageIO allocates with new and has its own worker threads. All its exceptions are caught in this section.

#ifdef GSF_USE_OIIO

static gsf_result gsf__oiio_fail(gsf_context* ctx, const char* name, gsf_result result, const char* what,
                                 const std::string& reason) {
    char line[200];
    snprintf(line, sizeof line, "%s", reason.c_str());
    for (char* c = line; *c; c++)
        if (*c == '\n' || *c == '\r') *c = ' ';
    return gsf_fail(ctx, result, "%s:0: %s (%s)", name, what, line);
}

// Format by the first bytes, because an image in memory may have any name.
static const char* gsf__oiio_format(const void* data, size_t size) {
    static const struct { const char *magic, *format; } formats[] = {{"\x76\x2f\x31\x01", "openexr"},
                                                                     {"II*\0", "tiff"}, {"MM\0*", "tiff"},
                                                                     {"II+\0", "tiff"}, {"MM\0+", "tiff"},
                                                                     {"\x89PNG", "png"}, {"\xff\xd8\xff\xe0", "jpeg"},
                                                                     {"\xff\xd8\xff\xe1", "jpeg"}};
    for (size_t i = 0; size >= 4 && i < GSF__COUNT(formats); i++)
        if (memcmp(data, formats[i].magic, 4) == 0) return formats[i].format;
    return NULL;
}

static gsf_result gsf__oiio_open(gsf_context* ctx, const char* name, const void* data, size_t size,
                                 OIIO::Filesystem::IOMemReader* memory, std::unique_ptr<OIIO::ImageInput>* out) {
    const char* format = gsf__oiio_format(data, size);
    if (format && strcmp(format, "png") == 0)
        GSF__TRY(gsf__check_png(ctx, name, (const char*)data, size, UINT64_MAX));
    std::unique_ptr<OIIO::ImageInput> input =
        format ? OIIO::ImageInput::create(format) : OIIO::ImageInput::open(name, nullptr, memory);
    if (!input)
        return gsf__oiio_fail(ctx, name, GSF_ERROR_FORMAT, "not an image format that this build can read", OIIO::geterror());
    if (!input->supports("ioproxy"))
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: OpenImageIO does not read %s from memory", name,
                        input->format_name());
    if (format) {
        OIIO::ImageSpec spec, config;
        config.attribute("oiio:UnassociatedAlpha", 1); // colours as stored, not premultiplied
        if (!input->set_ioproxy(memory) || !input->open(name, spec, config))
            return gsf__oiio_fail(ctx, name, GSF_ERROR_FORMAT, "image is malformed", input->geterror());
    }
    const OIIO::ImageSpec& spec = input->spec();
    if (spec.deep || spec.depth > 1 || spec.nchannels < 1)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:0: deep, volume or empty image", name);
    GSF__TRY(gsf__check_image_claim(ctx, name, spec.width, spec.height, size, GSF__PIXELS_PER_BYTE));
    if ((size_t)spec.nchannels > size)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: %d channels", name, spec.nchannels);
    *out = std::move(input);
    return GSF_OK;
}

static gsf_dtype gsf__oiio_dtype(OIIO::TypeDesc type) {
    switch (type.basetype) {
        case OIIO::TypeDesc::UINT8: return GSF_U8;
        case OIIO::TypeDesc::UINT16: return GSF_U16;
        case OIIO::TypeDesc::HALF: return GSF_F16;
        case OIIO::TypeDesc::DOUBLE: return GSF_F64;
        default: return GSF_F32; // wider integers are scaled to value / maximum
    }
}

static OIIO::TypeDesc gsf__oiio_type(gsf_dtype dtype) {
    switch (dtype) {
        case GSF_U8: return OIIO::TypeDesc::UINT8;
        case GSF_U16: return OIIO::TypeDesc::UINT16;
        case GSF_F16: return OIIO::TypeDesc::HALF;
        case GSF_F32: return OIIO::TypeDesc::FLOAT;
        case GSF_F64: return OIIO::TypeDesc::DOUBLE;
    }
    return OIIO::TypeDesc::UNKNOWN;
}

// Converts src (any channel count) to dst (1, 3 or 4 channels) of the same dtype, with the rules of stb: grey is replicated,
// colour becomes luma (77 R + 150 G + 29 B) / 256, a missing alpha is 1.
static void gsf__oiio_channels(const gsf_image* src, const gsf_image* dst) {
    double run[3][GSF__CONVERT_RUN];
    const int is_color = src->channels >= 3;
    for (int64_t y = 0; y < dst->height; y++)
        for (int32_t c = 0; c < dst->channels; c++)
            for (int64_t x = 0; x < dst->width; x += GSF__CONVERT_RUN) {
                const int64_t left = dst->width - x;
                const size_t n = left < GSF__CONVERT_RUN ? (size_t)left : (size_t)GSF__CONVERT_RUN;
                const char* from = (const char*)src->data + y * src->stride_y + x * src->stride_x;
                char* to = (char*)dst->data + y * dst->stride_y + x * dst->stride_x + c * dst->stride_c;
                const int luma = dst->channels == 1 && is_color;
                const int32_t alpha = src->channels == 4 ? 3 : src->channels == 2 ? 1 : -1;
                const int32_t channel = c == 3 ? alpha : is_color ? c : 0;
                for (int32_t k = 0; k < (luma ? 3 : 1) && channel >= 0; k++)
                    gsf__load_pixels(from + (luma ? k : channel) * src->stride_c, src->stride_x, src->dtype, n, run[k]);
                for (size_t i = 0; i < n && luma; i++)
                    run[0][i] = (77.0 * run[0][i] + 150.0 * run[1][i] + 29.0 * run[2][i]) / 256.0;
                for (size_t i = 0; i < n && channel < 0; i++) run[0][i] = 1.0;
                gsf__store_pixels(to, dst->stride_x, dst->dtype, n, run[0], 0);
            }
}

static gsf_result gsf__oiio_read(gsf_context* ctx, const char* name, const void* data, size_t size, int32_t channels,
                                 gsf_image* out) {
    OIIO::Filesystem::IOMemReader memory(data, size);
    std::unique_ptr<OIIO::ImageInput> input;
    GSF__TRY(gsf__oiio_open(ctx, name, data, size, &memory, &input));
    const OIIO::ImageSpec spec = input->spec();
    gsf_image file;
    GSF__TRY(gsf_make_image(ctx, gsf__oiio_dtype(spec.format), spec.width, spec.height, spec.nchannels, &file));
    gsf_result result = GSF_OK;
    if (!input->read_image(0, 0, 0, spec.nchannels, gsf__oiio_type(file.dtype), file.data))
        result = gsf__oiio_fail(ctx, name, GSF_ERROR_FORMAT, "image is truncated or malformed", input->geterror());
    file.color_space = spec.get_string_attribute("oiio:ColorSpace") == "Linear" ? GSF_COLOR_LINEAR : GSF_COLOR_SRGB;
    if (result == GSF_OK && (channels == 0 || channels == spec.nchannels)) {
        *out = file;
        return GSF_OK;
    }
    if (result == GSF_OK) result = gsf_make_image(ctx, file.dtype, spec.width, spec.height, channels, out);
    if (result == GSF_OK) {
        out->color_space = file.color_space;
        gsf__oiio_channels(&file, out);
    }
    gsf_destroy_image(ctx, &file);
    return result;
}

static gsf_result gsf__oiio_load(gsf_context* ctx, const char* name, const void* data, size_t size, int32_t channels,
                                 gsf_image* out) {
    try {
        return gsf__oiio_read(ctx, name, data, size, channels, out);
    } catch (...) {
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: OpenImageIO threw an exception", name);
    }
}

static gsf_result gsf__oiio_query(gsf_context* ctx, const char* name, const void* data, size_t size, int64_t* width,
                                  int64_t* height, int32_t* channels) {
    try {
        OIIO::Filesystem::IOMemReader memory(data, size);
        std::unique_ptr<OIIO::ImageInput> input;
        GSF__TRY(gsf__oiio_open(ctx, name, data, size, &memory, &input));
        *width = input->spec().width;
        *height = input->spec().height;
        *channels = input->spec().nchannels;
        return GSF_OK;
    } catch (...) {
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: OpenImageIO threw an exception", name);
    }
}

static gsf_result gsf__oiio_write(gsf_context* ctx, const char* name, const char* extension, const gsf_image* image,
                                  gsf_buffer* out) {
    const int exr = strcmp(extension, ".exr") == 0, png = strcmp(extension, ".png") == 0;
    const int tiff = strcmp(extension, ".tif") == 0 || strcmp(extension, ".tiff") == 0;
    if (image->channels > 4 || image->width > 1 << 24 || image->height > 1 << 24)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %lld x %lld with %d channels", name, (long long)image->width,
                        (long long)image->height, (int)image->channels);
    gsf_dtype dtype = image->dtype; // the nearest one that the format supports
    if (exr && dtype != GSF_F16) dtype = GSF_F32;
    if (tiff && dtype == GSF_F16) dtype = GSF_F32;
    if (png && dtype != GSF_U16) dtype = GSF_U8;
    const char* format = exr ? "openexr" : tiff ? "tiff" : png ? "png" : extension + (*extension == '.');
    std::unique_ptr<OIIO::ImageOutput> output = OIIO::ImageOutput::create(format);
    if (!output || !output->supports("ioproxy"))
        return gsf__oiio_fail(ctx, name, GSF_ERROR_UNSUPPORTED, "this build does not write such files",
                              OIIO::geterror());
    gsf_image packed;
    GSF__TRY(gsf_make_image(ctx, dtype, image->width, image->height, image->channels, &packed));
    packed.color_space = image->color_space;
    gsf_result result = gsf_convert_image(ctx, image, &packed);
    std::vector<unsigned char> bytes;
    if (result == GSF_OK) {
        OIIO::Filesystem::IOVecOutput memory(bytes);
        OIIO::ImageSpec spec((int)image->width, (int)image->height, (int)image->channels, gsf__oiio_type(dtype));
        if (!tiff) // in TIFF it becomes an EXIF directory; writing that to memory corrupts the file (OpenImageIO 2.4)
            spec.attribute("oiio:ColorSpace", image->color_space == GSF_COLOR_LINEAR ? "Linear" : "sRGB");
        if (!exr) spec.attribute("oiio:UnassociatedAlpha", 1);
        spec.attribute("CompressionQuality", (int)GSF__JPEG_QUALITY);
        if (!output->set_ioproxy(&memory) || !output->open(name, spec) ||
            !output->write_image(gsf__oiio_type(dtype), packed.data) || !output->close())
            result = gsf__oiio_fail(ctx, name, GSF_ERROR_IO, "cannot be encoded", output->geterror());
    }
    gsf_destroy_image(ctx, &packed);
    GSF__TRY(result);
    gsf_append_bytes(ctx, out, (const char*)bytes.data(), bytes.size());
    return out->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

static gsf_result gsf__oiio_encode(gsf_context* ctx, const char* name, const char* extension, const gsf_image* image,
                                   gsf_buffer* out) {
    try {
        return gsf__oiio_write(ctx, name, extension, image, out);
    } catch (...) {
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: OpenImageIO threw an exception", name);
    }
}

#endif // GSF_USE_OIIO

GSF__END_IMPLEMENTATION

#endif // GSF_BASE_IMPLEMENTED
#endif // GSFIXER_BASE_IMPLEMENTATION

// ---- >>lanes: code compiled once per instruction set ----------------------------

#ifdef GSF_INTERNALS_INCLUDED

#if defined(GSF__KERNELS_METRICS) && defined(GSF__ISA)

// The sum of absolute differences of bytes, or of their squares. It is exact, as 256 squares fit into a float.
GSF__V_KERNEL double GSF__V(gsf__difference_of_bytes)(const uint8_t* a, const uint8_t* b, int64_t n, int absolute) {
    gsf__vd sums[GSF__HALVES];
    double sum = 0.0;
    for (int h = 0; h < GSF__HALVES; h++) sums[h] = gsf__vd_set(0.0);
    for (int64_t i = 0, end; i < n;) {
        gsf__vf part = gsf__v_set(0.0f);
        for (end = i + 256 * GSF__LANES < n ? i + 256 * GSF__LANES : n; i < end; i += GSF__LANES) {
            const gsf__vf d = gsf__v_load_bytes(a + i, (size_t)(n - i)) - gsf__v_load_bytes(b + i, (size_t)(n - i));
            if (absolute) part = part + gsf__v_abs(d);
            else part = part + d * d;
        }
        for (int h = 0; h < GSF__HALVES; h++) sums[h] = sums[h] + gsf__vd_half(part, h);
    }
    for (int h = 0; h < GSF__HALVES; h++) sum += gsf__vd_sum(sums[h]);
    return sum;
}

// SSIM. Rows end with a vector that may overlap the one before it; shorter ones go value by value. The operations and their
// order are the same at every instruction set, and none is fused, so that results are the same, too.

// aa, bb: the squares, in aa both if bb is NULL; ab: the products
GSF__V_KERNEL void GSF__V(gsf__ssim_square)(const double* a, const double* b, size_t n, double* aa, double* bb, double* ab) {
    const size_t lanes = GSF__LANES / GSF__HALVES;
    size_t i = 0;
    for (; i + lanes <= n; i += lanes) {
        const gsf__vd x = gsf__vd_read(a + i), y = gsf__vd_read(b + i);
        gsf__vd_write(aa + i, bb ? x * x : x * x + y * y);
        if (bb) gsf__vd_write(bb + i, y * y);
        gsf__vd_write(ab + i, x * y);
    }
    for (; i < n; i++) {
        aa[i] = bb ? a[i] * a[i] : a[i] * a[i] + b[i] * b[i];
        if (bb) bb[i] = b[i] * b[i];
        ab[i] = a[i] * b[i];
    }
}

// out[i] = sum over t of weights[t] * rows[t][i], where taps is odd and the weights are symmetric: pairs of rows are added
// first, from the outermost one to the centre.
GSF__V_KERNEL void GSF__V(gsf__ssim_blur)(double* out, const double* const* rows, const double* weights, int taps, size_t n) {
    const size_t lanes = GSF__LANES / GSF__HALVES, step = 2 * lanes;
    const int last = taps - 1, half = taps / 2;
    const gsf__vd w0 = gsf__vd_set(weights[0]), centre = gsf__vd_set(weights[half]);
    for (size_t i = 0; n >= step; i = i + 2 * step <= n ? i + step : n - step) {
        gsf__vd s0 = w0 * (gsf__vd_read(rows[0] + i) + gsf__vd_read(rows[last] + i));
        gsf__vd s1 = w0 * (gsf__vd_read(rows[0] + i + lanes) + gsf__vd_read(rows[last] + i + lanes));
        for (int t = 1; t < half; t++) {
            const double *a = rows[t] + i, *b = rows[last - t] + i;
            const gsf__vd w = gsf__vd_set(weights[t]);
            s0 = s0 + w * (gsf__vd_read(a) + gsf__vd_read(b));
            s1 = s1 + w * (gsf__vd_read(a + lanes) + gsf__vd_read(b + lanes));
        }
        gsf__vd_write(out + i, s0 + centre * gsf__vd_read(rows[half] + i));
        gsf__vd_write(out + i + lanes, s1 + centre * gsf__vd_read(rows[half] + i + lanes));
        if (i + step == n) return;
    }
    for (size_t i = 0; i < n; i++) {
        double sum = weights[0] * (rows[0][i] + rows[last][i]);
        for (int t = 1; t < half; t++) sum += weights[t] * (rows[t][i] + rows[last - t][i]);
        out[i] = sum + weights[half] * rows[half][i];
    }
}

GSF__V_INLINE gsf__vd GSF__V(gsf__ssim_one)(const gsf__ssim_form* form, gsf__vd ma, gsf__vd mb, gsf__vd maa, gsf__vd mbb,
                                            gsf__vd mab) {
    const gsf__vd c1 = gsf__vd_set(0.01 * 0.01), c2 = gsf__vd_set(0.03 * 0.03), zero = gsf__vd_set(0.0);
    const gsf__vd two = gsf__vd_set(2.0), factor = gsf__vd_set(form->factor);
    gsf__vd va = maa - ma * ma, vb = mbb - mb * mb;
    if (form->clamp) {
        va = gsf__vd_max(zero, va);
        vb = gsf__vd_max(zero, vb);
    }
    const gsf__vd covariance = two * ((mab - ma * mb) * factor) + c2, variances = va * factor + vb * factor + c2;
    if (form->contrast) return covariance / variances;
    return ((two * ma * mb + c1) * covariance) / ((ma * ma + mb * mb + c1) * variances);
}

// The values of n pixels from the rows of `map`, `pitch` apart: means of a, b, aa, bb (unless they come together) and ab.
GSF__V_KERNEL void GSF__V(gsf__ssim_value)(const gsf__ssim_form* form, const double* map, size_t pitch, size_t n, double* out) {
    const size_t lanes = GSF__LANES / GSF__HALVES;
    const double *b = map + pitch, *aa = b + pitch, *bb = aa + pitch, *ab = form->together ? bb : bb + pitch;
    for (size_t i = 0; n >= lanes; i = i + 2 * lanes <= n ? i + lanes : n - lanes) {
        const gsf__vd both = form->together ? gsf__vd_set(0.0) : gsf__vd_read(bb + i);
        const gsf__vd mab = gsf__vd_read(ab + i);
        gsf__vd_write(out + i, GSF__V(gsf__ssim_one)(form, gsf__vd_read(map + i), gsf__vd_read(b + i), gsf__vd_read(aa + i),
                                                     both, mab));
        if (i + lanes == n) return;
    }
    for (size_t i = 0; i < n; i++)
        out[i] = gsf__ssim_one_scalar(form, map[i], b[i], aa[i], form->together ? 0.0 : bb[i], ab[i]);
}

#endif // GSF__KERNELS_METRICS

#ifdef GSF__KERNELS_POWERS
#if GSF__LANES > 1

// Constants of 2^x. Long loops pin them to registers, because compilers otherwise reload them in each iteration.
typedef struct gsf__v_exp2_terms { gsf__vf lowest, rounder, c[7]; } gsf__v_exp2_terms;

// Adding the rounder (1.5 * 2^23 + 126) to x in [-126, 129] leaves n + 126 in the low bits, where n is the integer nearest
// to x. Shifted left by 23, these are the bits of 2^(n - 1): 0 for n = -126, inf for n = 129. The polynomial (Cephes' exp2f)
// therefore gives 2 * 2^f, so that one multiplication yields every finite power.
GSF__V_INLINE gsf__v_exp2_terms gsf__v_exp2_of(int pinned) {
    gsf__v_exp2_terms t;
    t.lowest = gsf__v_set(-126.0f);
    t.rounder = gsf__v_set(12583038.0f);
    t.c[0] = gsf__v_set(2.0f);
    t.c[1] = gsf__v_set(2.0f * 6.931472028550421e-1f);
    t.c[2] = gsf__v_set(2.0f * 2.402264791363012e-1f);
    t.c[3] = gsf__v_set(2.0f * 5.550332471162809e-2f);
    t.c[4] = gsf__v_set(2.0f * 9.618437357674640e-3f);
    t.c[5] = gsf__v_set(2.0f * 1.339887440266574e-3f);
    t.c[6] = gsf__v_set(2.0f * 1.535336188319500e-4f);
    if (pinned) {
        gsf__v_pin(&t.lowest);
        gsf__v_pin(&t.rounder);
        gsf__v_pin(&t.c[0]);
        gsf__v_pin(&t.c[1]);
        gsf__v_pin(&t.c[2]);
        gsf__v_pin(&t.c[3]);
        gsf__v_pin(&t.c[4]);
        gsf__v_pin(&t.c[5]);
        gsf__v_pin(&t.c[6]);
    }
    return t;
}

// 2^(n + f) for rounded = n + rounder, |f| <= 1/2.
GSF__V_INLINE gsf__vf gsf__v_power(const gsf__v_exp2_terms* t, gsf__vf rounded, gsf__vf f) {
    gsf__vf p = gsf__v_madd(t->c[6], f, t->c[5]);
    p = gsf__v_madd(p, f, t->c[4]);
    p = gsf__v_madd(p, f, t->c[3]);
    p = gsf__v_madd(p, f, t->c[2]);
    p = gsf__v_madd(p, f, t->c[1]);
    p = gsf__v_madd(p, f, t->c[0]);
    return p * gsf__vi_as_floats(gsf__vi_shl(gsf__v_bits(rounded), 23));
}

// 2^x for x <= 129 or NaN. Relative error below 2e-7; 2^0 = 1; results below 2^-125.5 (1.7e-38) are 0; NaN gives NaN.
GSF__V_INLINE gsf__vf gsf__v_exp2_low(const gsf__v_exp2_terms* t, gsf__vf x) {
    x = gsf__v_max(t->lowest, x);
    const gsf__vf rounded = x + t->rounder;
    return gsf__v_power(t, rounded, x - (rounded - t->rounder));
}

// 2^x for all x, with the same properties; inf above 128.
GSF__V_INLINE gsf__vf gsf__v_exp2(gsf__vf x) {
    const gsf__v_exp2_terms t = gsf__v_exp2_of(0);
    return gsf__v_exp2_low(&t, gsf__v_min(gsf__v_set(129.0f), x));
}

// e^x for all x. Relative error below 2e-7; results below 1.7e-38 are 0 and above the largest float inf; NaN gives NaN.
GSF__V_INLINE gsf__vf gsf__v_exp(gsf__vf x) {
    const gsf__v_exp2_terms t = gsf__v_exp2_of(0);
    const gsf__vf log2_e = gsf__v_set(1.44269504f), log2_e_low = gsf__v_set(1.92596299e-8f);
    x = gsf__v_min(gsf__v_set(89.4f), gsf__v_max(gsf__v_set(-87.4f), x)); // exponents of 2: -126.1 and 129
    const gsf__vf rounded = gsf__v_madd(x, log2_e, t.rounder), n = rounded - t.rounder;
#if GSF__FUSED
    const gsf__vf f = gsf__v_madd(x, log2_e_low, gsf__v_msub(x, log2_e, n));
#else // the remainder of x first: the integer part of n times the first part of ln 2 is exact
    const gsf__vf rest = (x - n * gsf__v_set(0.693359375f)) - n * gsf__v_set(-2.12194440e-4f);
    const gsf__vf f = rest * log2_e + rest * log2_e_low;
#endif
    return gsf__v_power(&t, rounded, f);
}

#endif
#endif // GSF__KERNELS_POWERS

#ifndef GSF__ISA
#if !defined(GSF__POWERS_INCLUDED) && !defined(GSF__KERNELS)
#define GSF__POWERS_INCLUDED
#define GSF__KERNELS "gsfixer.h"
#define GSF__KERNELS_POWERS
#define GSF__KERNELS_AVX512
#define GSF__KERNELS_SIMD128
GSF__BEGIN_IMPLEMENTATION
#include "gsfixer.h" // compiles the kernels above
GSF__END_IMPLEMENTATION
#undef GSF__KERNELS_POWERS
#endif

#ifdef GSF__KERNELS // of a module, as described in >>lanes; it has already opened GSF__BEGIN_IMPLEMENTATION
#define GSF__ISA scalar
#include GSF__KERNELS
#undef GSF__ISA
#if GSF__X86
#define GSF__ISA avx2
#include GSF__KERNELS
#undef GSF__ISA
#endif
#if GSF__X86 && defined(GSF__KERNELS_AVX512)
#define GSF__ISA avx512
#include GSF__KERNELS
#undef GSF__ISA
#endif
#if GSF__SIMD128 && defined(GSF__KERNELS_SIMD128)
#define GSF__ISA simd128
#include GSF__KERNELS
#undef GSF__ISA
#endif
#undef GSF__KERNELS
#undef GSF__KERNELS_AVX512
#undef GSF__KERNELS_SIMD128
#endif
#endif // GSF__ISA

#endif // GSF_INTERNALS_INCLUDED
