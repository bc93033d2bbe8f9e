/* gsfixer_nn.h - tensors, kernels and the networks of the reference-guided video restorer
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       In exactly one C (C11) or C++ (C++17) file:
           #define GSFIXER_IMPLEMENTATION      // or GSFIXER_NN_IMPLEMENTATION for this module only
           #include "gsfixer_nn.h"             // includes gsfixer.h by itself
       Everywhere else include it without the define. It knows nothing of splats: the repair loop sees the restorer
       only through the interface of gsfixer.h.

   WHAT IT DOES NOT DO
       No training, no automatic differentiation, no graph: the networks are straight-line C. It converts no weight
       file and fetches none.

   CONVENTIONS
       tensors         dense, row-major, the last dimension contiguous; shapes are written (rows, columns)
       activations     float32; weights as the file has them (f32, bf16 or f16), widened while they are packed
       linear layers   y = x w^T + b with w (out, in), as PyTorch stores it
       video           VAE: (channels, frames, height, width); transformer and latents: (frames, channels, height, width)
       pixels          [-1, 1] at the VAE's border, [0, 1] at the restorer's

   MEMORY      Weight files are mapped where the platform can (else read whole) and used in place; what no layer touches
               never leaves the disk. Kernels take a gsf_nn_workspace that grows to the largest need and stays there.
   THREADS     As gsfixer.h: the same bits for any number of workers.
   SOURCES     GSFixer (Yin et al. 2025); CogVideoX (Yang et al. 2024); DDIM (Song et al. 2021), zero terminal SNR (Lin et
               al. 2024); online softmax (Milakov and Gimelshein 2018), FlashAttention (Dao et al. 2022).
   SECTIONS    >>nn numbers >>nn workspace >>nn files >>nn vector >>nn activations >>nn linear >>nn norms
               >>nn attention >>nn convolution >>nn positions >>nn scheduler >>nn transformer >>nn vae >>nn sampling
               >>nn restorer
*/
#ifndef GSF_NN_INCLUDED
#define GSF_NN_INCLUDED

#include "gsfixer.h"

#ifdef __cplusplus
extern "C" {
#endif

// ---- tensors and weight files ---------------------------------------------------

typedef enum gsf_nn_dtype {
    GSF_NN_F32 = 0, GSF_NN_BF16, GSF_NN_F16, GSF_NN_F64, GSF_NN_U8, GSF_NN_I8, GSF_NN_I16, GSF_NN_I32, GSF_NN_I64,
} gsf_nn_dtype;

GSF_API size_t gsf_nn_dtype_size(gsf_nn_dtype dtype);      // bytes of one element
GSF_API const char* gsf_nn_dtype_name(gsf_nn_dtype dtype); // as safetensors spells it: "BF16"

enum { GSF_NN_MAX_RANK = 8 };

typedef struct gsf_tensor { // a view; owns nothing
    const char* name;
    const void* data;       // row-major; in weight files of ANY alignment
    gsf_nn_dtype dtype;
    int32_t rank;           // 0: one element
    int64_t shape[GSF_NN_MAX_RANK];
    int64_t count;          // product of the shape
} gsf_tensor;

// A float tensor over the caller's memory, for arguments.
GSF_API gsf_tensor gsf_nn_wrap_tensor(const char* name, const float* data, int32_t rank, const int64_t* shape);

typedef struct gsf_nn_weights { // an open file or folder of safetensors; tensors sorted by name
    char name[256];             // of the file or folder, for error texts
    gsf_tensor* tensors;
    size_t tensor_count;
    uint64_t mapped_bytes;      // file-backed: the system may drop them at any time
    uint64_t read_bytes;        // held in memory because the platform or the io hook cannot map
    void* files;                // private
} gsf_nn_weights;

// Opens one .safetensors file, or a folder: its *.safetensors.index.json with all shards, else its only .safetensors
// file. `prefix` (may be NULL) is the file name's start when a folder holds several ("diffusion_pytorch_model").
// Every length, offset, shape and dtype is checked: malformed files give GSF_ERROR_FORMAT with file and byte offset.
GSF_API GSF_NODISCARD gsf_result gsf_nn_open_weights(gsf_context* ctx, const char* path, const char* prefix,
                                                     gsf_nn_weights* out);
// The same over one file's bytes, which the caller keeps until the weights are closed.
GSF_API GSF_NODISCARD gsf_result gsf_nn_open_weights_memory(gsf_context* ctx, const char* name, const void* data,
                                                            size_t size, gsf_nn_weights* out);
GSF_API void gsf_nn_close_weights(gsf_context* ctx, gsf_nn_weights* weights);
GSF_API const gsf_tensor* gsf_nn_find_tensor(const gsf_nn_weights* weights, const char* name); // NULL when absent
// Writes a safetensors file (names must differ; 8-byte aligned data, as the official writer does).
GSF_API GSF_NODISCARD gsf_result gsf_nn_save_tensors(gsf_context* ctx, const char* path, const gsf_tensor* tensors,
                                                     size_t count);
// Widens `count` elements from `first` to float (f32, bf16, f16, f64 and the integers).
GSF_API void gsf_nn_read_tensor(const gsf_tensor* tensor, int64_t first, int64_t count, float* out);

// ---- kernels --------------------------------------------------------------------
// All pointers are float32 and 4-byte aligned; outputs do not overlap inputs unless a comment allows it.

typedef struct gsf_nn_workspace { // scratch memory of kernels; zero to begin with, grows, and is reused
    void* memory;
    size_t size;
} gsf_nn_workspace;

GSF_API void gsf_nn_destroy_workspace(gsf_context* ctx, gsf_nn_workspace* workspace);

typedef enum gsf_nn_activation { GSF_NN_LINEAR = 0, GSF_NN_GELU_TANH, GSF_NN_SILU } gsf_nn_activation;

typedef struct gsf_nn_linear_desc {
    const float* x;            // (rows, in), row stride ldx
    int64_t rows, ldx;         // ldx 0: in
    const gsf_tensor* weight;  // (out, in); f32, bf16 or f16. Higher ranks: (out, product of the rest)
    const gsf_tensor* bias;    // (out) or NULL
    gsf_nn_activation activation;
    const float* gate;         // (out) or NULL: y += gate * activation(x w^T + b) instead of y = ...
    int accumulate;            // y += activation(x w^T + b) instead of y = ...
    float* y;                  // (rows, out), row stride ldy
    int64_t ldy;               // 0: out
} gsf_nn_linear_desc;

// A linear layer with its activation and residual. `workspace` NULL: scratch for this call only.
GSF_API GSF_NODISCARD gsf_result gsf_nn_linear(gsf_context* ctx, gsf_nn_workspace* workspace,
                                               const gsf_nn_linear_desc* desc);

typedef struct gsf_nn_attention_desc {
    int64_t queries, keys;     // rows of q and out; of k and v
    int32_t heads, head_dim;   // head h stands in columns h*head_dim ...
    const float *q, *k, *v;
    int64_t ldq, ldk, ldv;     // row strides, 0: heads*head_dim
    const unsigned char* mask; // (heads, queries, keys), 1 = may attend; NULL = all. A row of zeros gives 0.
    float scale;               // of the logits, 0: 1/sqrt(head_dim)
    float* out;                // (queries, heads*head_dim), row stride ldo; may be q
    int64_t ldo;
} gsf_nn_attention_desc;

// softmax(scale q k^T) v for every head, without the matrix of logits.
GSF_API GSF_NODISCARD gsf_result gsf_nn_attention(gsf_context* ctx, gsf_nn_workspace* workspace,
                                                  const gsf_nn_attention_desc* desc);

// Normalisations over the last dimension of (rows, dim); y may be x; weight, bias (dim) or NULL. Variances are biased
// and two-pass.
GSF_API void gsf_nn_layer_norm(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight,
                               const float* bias, float eps, float* y);
GSF_API void gsf_nn_rms_norm(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight, float eps,
                             float* y);
// y = layer_norm(x) * (1 + scale) + shift, scale and shift (dim): one pass of an adaptive layer norm.
GSF_API void gsf_nn_layer_norm_modulated(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight,
                                         const float* bias, float eps, const float* scale, const float* shift, float* y);
// x: (channels, count); statistics over the channels of a group and all their values; y may be x.
GSF_API void gsf_nn_group_norm(gsf_context* ctx, const float* x, int64_t channels, int64_t count, int64_t groups,
                               const float* weight, const float* bias, float eps, float* y);
// LayerNorm over each head of q or k, then the rotation of interleaved pairs on rows `rope_first` and up, in place.
// cos, sin: (rows - rope_first, head_dim) or NULL: no rotation. weight, bias (head_dim) or NULL.
GSF_API void gsf_nn_head_norm_rope(gsf_context* ctx, float* x, int64_t rows, int64_t ldx, int32_t heads, int32_t head_dim,
                                   const float* weight, const float* bias, float eps, const float* cos, const float* sin,
                                   int64_t rope_first);
GSF_API void gsf_nn_activate(gsf_context* ctx, gsf_nn_activation activation, const float* x, int64_t count, float* y);
// Rows of (rows, columns) to softmax(scale * row); y may be x.
GSF_API void gsf_nn_softmax(gsf_context* ctx, const float* x, int64_t rows, int64_t columns, float scale, float* y);

// ---- convolution ----------------------------------------------------------------
// Activations of convolutions are channels-last: (frames, height, width, channels).

typedef struct gsf_nn_conv_desc {
    const float* x;            // (frames, height, width, in)
    int64_t frames, height, width;
    const gsf_tensor* weight;  // (out, in, kh, kw): frame by frame; (out, in, kt, kh, kw), kt 1 or 3: causal in time.
    const gsf_tensor* bias;    // (out) or NULL                      kh = kw is 1 or 3; f32, bf16 or f16
    const float* before;       // (2, height, width, in): the frames before x; NULL: x's first frame, twice. kt = 3 only
    int halve;                 // stride 2 and one row and column of zeros below and to the right, instead of stride 1
    int accumulate;            //   and a border of zeros. y += instead of y = ...
    float* y;                  // (frames, height, width, out); halve: (frames, height/2, width/2, out), rounded down
} gsf_nn_conv_desc;

// A convolution, 3D ones causal in time. `workspace` (or, where it is NULL, memory for this call) holds the widened
// weights and three frames of the input with their borders.
GSF_API GSF_NODISCARD gsf_result gsf_nn_convolve(gsf_context* ctx, gsf_nn_workspace* workspace,
                                                 const gsf_nn_conv_desc* desc);

// ---- video autoencoder ----------------------------------------------------------
// AutoencoderKLCogVideoX as diffusers 0.32.1 runs it: clips go through in chunks of 8 frames (encoder) or 2 latent frames
// (decoder), the remainder joins the first chunk, causal convolutions see the last two frames of the chunk before, and the
// group norms' statistics are each chunk's own. latents are (latent_channels, frames, height/8, width/8), unscaled.

enum { GSF_NN_VAE_LEVELS = 8 };

typedef struct gsf_nn_vae { // an open model; its weights stay in the mapped file
    int32_t in_channels, out_channels, latent_channels;
    int32_t levels, channels[GSF_NN_VAE_LEVELS]; // of the encoder's levels, finest first
    int32_t layers_per_block, norm_groups;
    int32_t spatial_ratio, temporal_ratio;       // pixels per latent pixel; frames per latent frame
    int32_t sample_height, sample_width;         // the pixels that the model was made for; tiles are half of them
    double norm_eps, scaling_factor;             // the diffusion model sees latents * scaling_factor
    gsf_nn_weights weights;
    void* nets;                                  // private
} gsf_nn_vae;

// Opens a diffusers folder: config.json and diffusion_pytorch_model*.safetensors. A missing, misshaped or surplus tensor
// gives GSF_ERROR_FORMAT and is named.
GSF_API GSF_NODISCARD gsf_result gsf_nn_make_vae(gsf_context* ctx, const char* folder, gsf_nn_vae* out);
GSF_API void gsf_nn_destroy_vae(gsf_context* ctx, gsf_nn_vae* vae);

typedef struct gsf_nn_vae_desc {
    int tiled;                 // in overlapping tiles, blended linearly: less memory, other values (statistics per tile)
    int32_t tile_height, tile_width;   // pixels, 0: half of sample_height, sample_width
    double overlap_height, overlap_width; // parts of a tile, 0: 1/6 and 1/5. Tile times overlap must be whole latents.
    double max_bytes;          // refuse before starting, with GSF_ERROR_OUT_OF_MEMORY, what needs more; 0: no limit
} gsf_nn_vae_desc;

typedef enum gsf_nn_vae_way { GSF_NN_VAE_ENCODE = 0, GSF_NN_VAE_DECODE } gsf_nn_vae_way;

typedef struct gsf_nn_vae_info {
    int64_t frames, height, width; // of the result. 2 latent frames give 8 frames, 3 give 9: the official code's way
    int64_t chunks;                // steps of progress
    double flops;                  // 2 per multiply-add of the convolutions that will be computed
    double bytes;                  // memory taken besides input, output and mapped weights, at the peak
} gsf_nn_vae_info;

// Sizes and cost of a run over `frames` x `height` x `width` (latents when decoding), without running it. `desc` may be
// NULL.
GSF_API GSF_NODISCARD gsf_result gsf_nn_query_vae(gsf_context* ctx, const gsf_nn_vae* vae, gsf_nn_vae_way way,
                                                  const gsf_nn_vae_desc* desc, int64_t frames, int64_t height,
                                                  int64_t width, gsf_nn_vae_info* out);

// video: (in_channels, frames, height, width) in [-1, 1], any size of at least 8 x 8. mean, logvar (or NULL):
// (latent_channels, info.frames, info.height, info.width); logvar is clamped to [-30, 20].
// A NaN or infinity gives GSF_ERROR_NUMERIC and the name of the layer where it appears. On error outputs are zeroed.
GSF_API GSF_NODISCARD gsf_result gsf_nn_vae_encode(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                                   const float* video, int64_t frames, int64_t height, int64_t width,
                                                   float* mean, float* logvar);
// latents: (latent_channels, frames, height, width); video: (out_channels, info.frames, info.height, info.width).
GSF_API GSF_NODISCARD gsf_result gsf_nn_vae_decode(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                                   const float* latents, int64_t frames, int64_t height, int64_t width,
                                                   float* video);

#ifdef __cplusplus
}
#endif

#endif // GSF_NN_INCLUDED

// End of the API; what follows is the implementation.

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_NN_IMPLEMENTATION)
#define GSFIXER_NN_IMPLEMENTATION
#endif
#if defined(GSFIXER_NN_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_NN_IMPLEMENTED
#define GSF_NN_IMPLEMENTED

GSF__BEGIN_IMPLEMENTATION

// ---- >>nn numbers ---------------------------------------------------------------

static float gsf__bf16_to_float(uint16_t value) {
    const uint32_t bits = (uint32_t)value << 16;
    float out;
    memcpy(&out, &bits, sizeof out);
    return out;
}

// Round to nearest, ties to even; a NaN stays one.
static uint16_t gsf__float_to_bf16(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    if ((bits & 0x7fffffffu) > 0x7f800000u) return (uint16_t)(bits >> 16 | 0x40u);
    return (uint16_t)((bits + 0x7fffu + (bits >> 16 & 1u)) >> 16);
}

GSF_API size_t gsf_nn_dtype_size(gsf_nn_dtype dtype) {
    switch (dtype) {
        case GSF_NN_F32: case GSF_NN_I32: return 4;
        case GSF_NN_BF16: case GSF_NN_F16: case GSF_NN_I16: return 2;
        case GSF_NN_F64: case GSF_NN_I64: return 8;
        case GSF_NN_U8: case GSF_NN_I8: return 1;
    }
    return 0;
}

GSF_API const char* gsf_nn_dtype_name(gsf_nn_dtype dtype) {
    switch (dtype) {
        case GSF_NN_F32: return "F32";
        case GSF_NN_BF16: return "BF16";
        case GSF_NN_F16: return "F16";
        case GSF_NN_F64: return "F64";
        case GSF_NN_U8: return "U8";
        case GSF_NN_I8: return "I8";
        case GSF_NN_I16: return "I16";
        case GSF_NN_I32: return "I32";
        case GSF_NN_I64: return "I64";
    }
    return "unknown";
}

GSF_API gsf_tensor gsf_nn_wrap_tensor(const char* name, const float* data, int32_t rank, const int64_t* shape) {
    gsf_tensor tensor;
    memset(&tensor, 0, sizeof tensor);
    tensor.name = name;
    tensor.data = data;
    tensor.rank = rank;
    tensor.count = 1;
    for (int32_t i = 0; i < rank && i < GSF_NN_MAX_RANK; i++) {
        tensor.shape[i] = shape[i];
        tensor.count *= shape[i];
    }
    return tensor;
}

GSF_API void gsf_nn_read_tensor(const gsf_tensor* tensor, int64_t first, int64_t count, float* out) {
    const char* p = (const char*)tensor->data + (size_t)first * gsf_nn_dtype_size(tensor->dtype);
#define GSF_X(type, value) \
    for (int64_t i = 0; i < count; i++, p += sizeof(type)) { type v; memcpy(&v, p, sizeof v); out[i] = (value); } break
    switch (tensor->dtype) {
        case GSF_NN_F32: memcpy(out, p, (size_t)count * sizeof(float)); break;
        case GSF_NN_BF16: GSF_X(uint16_t, gsf__bf16_to_float(v));
        case GSF_NN_F16: GSF_X(uint16_t, gsf__half_to_float(v));
        case GSF_NN_F64: GSF_X(double, (float)v);
        case GSF_NN_U8: GSF_X(uint8_t, (float)v);
        case GSF_NN_I8: GSF_X(int8_t, (float)v);
        case GSF_NN_I16: GSF_X(int16_t, (float)v);
        case GSF_NN_I32: GSF_X(int32_t, (float)v);
        case GSF_NN_I64: GSF_X(int64_t, (float)v);
    }
#undef GSF_X
}

// ---- >>nn workspace -------------------------------------------------------------

// At least `size` bytes; what the workspace held before is lost. NULL when out of memory.
static void* gsf__nn_scratch(gsf_context* ctx, gsf_nn_workspace* workspace, size_t size) {
    if (size <= workspace->size) return workspace->memory;
    gsf_nn_destroy_workspace(ctx, workspace);
    workspace->memory = gsf_alloc(ctx, size, 1);
    workspace->size = workspace->memory ? size : 0;
    return workspace->memory;
}

GSF_API void gsf_nn_destroy_workspace(gsf_context* ctx, gsf_nn_workspace* workspace) {
    gsf_free(ctx, workspace->memory);
    memset(workspace, 0, sizeof *workspace);
}

// ---- >>nn files -----------------------------------------------------------------

/* A safetensors file:
       u64 n (little-endian) | n bytes of JSON, padded with spaces | data
       {"__metadata__": {"key": "text", ...}, "name": {"dtype": "BF16", "shape": [2, 3], "data_offsets": [begin, end]}, ...}
   Offsets count from the data's first byte. As the official reader does, this one demands that the tensors cover the data
   without hole, overlap or rest. (github.com/huggingface/safetensors, README and safetensors/src/tensor.rs) */

enum { GSF__NN_FILE_HEAD = 8, GSF__NN_HEADER_MAX = 100000000 }; // bytes; the limit is the official reader's

typedef enum gsf__nn_holder { GSF__NN_BORROWED, GSF__NN_READ, GSF__NN_MAPPED } gsf__nn_holder;

typedef struct gsf__nn_file {
    const unsigned char* data;
    size_t size;
    gsf__nn_holder holder;
    char* names; // of its tensors, one after the other
    size_t names_size;
} gsf__nn_file;

typedef struct gsf__nn_files {
    gsf__nn_file* files;
    size_t count, capacity, tensor_capacity;
} gsf__nn_files;

// ---- platform: what a path leads to, what a folder holds, mapping a file

typedef enum gsf__nn_path_kind { GSF__NN_UNKNOWN, GSF__NN_IS_FILE, GSF__NN_IS_FOLDER } gsf__nn_path_kind;

// Name of the one file of `folder` that ends in `suffix`; its size is 0 where there is none. More than one is an error.
typedef struct gsf__nn_listing {
    const char *folder, *suffix;
    gsf_text found;
} gsf__nn_listing;

static int gsf__nn_ends_in(const char* text, const char* suffix) {
    const size_t size = strlen(text), end = strlen(suffix);
    return size >= end && memcmp(text + size - end, suffix, end) == 0;
}

#if defined(__unix__) || defined(__APPLE__)
#include <dirent.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

static gsf__nn_path_kind gsf__nn_look_at_path(const char* path) {
    struct stat info;
    if (stat(path, &info) != 0) return GSF__NN_UNKNOWN;
    return S_ISDIR(info.st_mode) ? GSF__NN_IS_FOLDER : GSF__NN_IS_FILE;
}

static gsf_result gsf__nn_list_folder(gsf_context* ctx, gsf__nn_listing* listing) {
    DIR* folder = opendir(listing->folder);
    if (!folder) return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", listing->folder, strerror(errno));
    gsf_result result = GSF_OK;
    for (const struct dirent* entry; result == GSF_OK && (entry = readdir(folder)) != NULL;) {
        if (entry->d_name[0] == '.' || !gsf__nn_ends_in(entry->d_name, listing->suffix)) continue;
        if (listing->found.size) {
            result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: holds %s and %s: name one by its prefix",
                              listing->folder, listing->found.data, entry->d_name);
        } else {
            gsf_text_append(ctx, &listing->found, entry->d_name, strlen(entry->d_name));
            if (listing->found.failed) result = GSF_ERROR_OUT_OF_MEMORY;
        }
    }
    closedir(folder);
    return result;
}

// *data is NULL where the file cannot be mapped, but may be readable.
static gsf_result gsf__nn_map(gsf_context* ctx, const char* path, const unsigned char** data, size_t* size) {
    struct stat info;
    *data = NULL;
    *size = 0;
    const int file = open(path, O_RDONLY);
    if (file < 0) return gsf_fail(ctx, GSF_ERROR_IO, "%s: %s", path, strerror(errno));
    if (fstat(file, &info) == 0 && S_ISREG(info.st_mode) && info.st_size > 0 &&
        (uint64_t)info.st_size <= SIZE_MAX / 2) {
        void* mapping = mmap(NULL, (size_t)info.st_size, PROT_READ, MAP_PRIVATE, file, 0);
        if (mapping != MAP_FAILED) {
            *data = (const unsigned char*)mapping;
            *size = (size_t)info.st_size;
        }
    }
    close(file);
    return GSF_OK;
}

static void gsf__nn_unmap(const unsigned char* data, size_t size) { munmap((void*)(uintptr_t)data, size); }
#else
static gsf__nn_path_kind gsf__nn_look_at_path(const char* path) { (void)path; return GSF__NN_UNKNOWN; }

static gsf_result gsf__nn_list_folder(gsf_context* ctx, gsf__nn_listing* listing) {
    (void)ctx;
    (void)listing;
    return GSF_OK;
}

static gsf_result gsf__nn_map(gsf_context* ctx, const char* path, const unsigned char** data, size_t* size) {
    (void)ctx;
    (void)path;
    *data = NULL;
    *size = 0;
    return GSF_OK;
}

static void gsf__nn_unmap(const unsigned char* data, size_t size) {
    (void)data;
    (void)size;
}
#endif

// ---- reading the header

// A name for one line of text: ASCII, and not too long.
typedef struct gsf__nn_shown { char text[100]; } gsf__nn_shown;

static gsf__nn_shown gsf__nn_show(const char* name) {
    gsf__nn_shown shown;
    snprintf(shown.text, sizeof shown.text, "%s", name);
    for (char* c = shown.text; *c; c++)
        if (*c < 0x20 || *c > 0x7e) *c = '?';
    return shown;
}

// The end of a path that a document's name (gsf_json) can hold.
static const char* gsf__nn_path_end(const char* path) {
    const size_t size = strlen(path), room = sizeof ((gsf_json*)0)->name - 1;
    return size > room ? path + (size - room) : path;
}

// A whole number as it stands in the text, without sign, fraction or exponent, up to 2^63 - 1. 0 where it is none.
static int gsf__nn_read_size(const char* text, const gsf_json_value* value, uint64_t* out) {
    *out = 0;
    if (value->type != GSF_JSON_NUMBER) return 0;
    const char* p = text + value->offset; // what follows it in a checked document is no digit
    if (*p == '-') return 0;
    for (; *p >= '0' && *p <= '9'; p++) {
        if (*out > ((uint64_t)INT64_MAX - (uint64_t)(*p - '0')) / 10) return 0;
        *out = *out * 10 + (uint64_t)(*p - '0');
    }
    return *p != '.' && *p != 'e' && *p != 'E';
}

typedef struct gsf__nn_header { // one file's header while it is read
    gsf_context* ctx;
    const char* name;
    const char* text;       // the whole file's first byte
    const char* data;       // the first byte behind the header
    uint64_t data_size;
    gsf_json json;
} gsf__nn_header;

static gsf_result gsf__nn_entry_fail(const gsf__nn_header* h, const gsf_json_value* at, const gsf_json_value* entry,
                                     gsf_result result, const char* text) {
    return gsf_fail(h->ctx, result, "%s:%u: tensor %s: %s", h->name, (unsigned)at->offset, gsf__nn_show(entry->key).text,
                    text);
}

static gsf_result gsf__nn_read_dtype(const gsf__nn_header* h, const gsf_json_value* entry, gsf_tensor* out) {
    const gsf_json_value* value = gsf_json_member(&h->json, entry, "dtype");
    if (!value || value->type != GSF_JSON_STRING)
        return gsf__nn_entry_fail(h, value ? value : entry, entry, GSF_ERROR_FORMAT, "\"dtype\" is not given as text");
    for (int i = GSF_NN_F32; i <= GSF_NN_I64; i++) {
        out->dtype = (gsf_nn_dtype)i;
        if (strcmp(value->string, gsf_nn_dtype_name(out->dtype)) == 0) return GSF_OK;
    }
    out->dtype = GSF_NN_U8;
    if (strcmp(value->string, "BOOL") == 0) return GSF_OK;
    char text[140];
    snprintf(text, sizeof text, "dtype %.30s is not supported", gsf__nn_show(value->string).text);
    return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_UNSUPPORTED, text);
}

static gsf_result gsf__nn_read_shape(const gsf__nn_header* h, const gsf_json_value* entry, gsf_tensor* out) {
    const gsf_json_value* value = gsf_json_member(&h->json, entry, "shape");
    if (!value || value->type != GSF_JSON_ARRAY)
        return gsf__nn_entry_fail(h, value ? value : entry, entry, GSF_ERROR_FORMAT, "\"shape\" is not given as a list");
    if (value->count > GSF_NN_MAX_RANK)
        return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_UNSUPPORTED, "more than 8 dimensions");
    uint64_t count = 1, size;
    for (uint32_t i = value->child; i; i = h->json.values[i].next) {
        if (!gsf__nn_read_size(h->text, &h->json.values[i], &size))
            return gsf__nn_entry_fail(h, &h->json.values[i], entry, GSF_ERROR_FORMAT, "a dimension is no whole number");
        if (size != 0 && count > (uint64_t)INT64_MAX / size)
            return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_FORMAT, "the shape overflows");
        count *= size;
        out->shape[out->rank++] = (int64_t)size;
    }
    out->count = (int64_t)count;
    return GSF_OK;
}

static gsf_result gsf__nn_read_place(const gsf__nn_header* h, const gsf_json_value* entry, gsf_tensor* out) {
    const gsf_json_value* value = gsf_json_member(&h->json, entry, "data_offsets");
    uint64_t begin, end;
    if (!value || value->type != GSF_JSON_ARRAY || value->count != 2 ||
        !gsf__nn_read_size(h->text, gsf_json_element(&h->json, value, 0), &begin) ||
        !gsf__nn_read_size(h->text, gsf_json_element(&h->json, value, 1), &end))
        return gsf__nn_entry_fail(h, value ? value : entry, entry, GSF_ERROR_FORMAT,
                                  "\"data_offsets\" are not two whole numbers");
    char text[160];
    if (begin > end || end > h->data_size) {
        snprintf(text, sizeof text, "bytes %llu to %llu do not lie in the %llu bytes of data", (unsigned long long)begin,
                 (unsigned long long)end, (unsigned long long)h->data_size);
        return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_FORMAT, text);
    }
    const uint64_t size = gsf_nn_dtype_size(out->dtype), count = (uint64_t)out->count;
    if (count > UINT64_MAX / size || count * size != end - begin) {
        snprintf(text, sizeof text, "%llu bytes for %llu values of %s", (unsigned long long)(end - begin),
                 (unsigned long long)count, gsf_nn_dtype_name(out->dtype));
        return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_FORMAT, text);
    }
    out->data = h->data + begin;
    return GSF_OK;
}

static gsf_result gsf__nn_read_entry(const gsf__nn_header* h, const gsf_json_value* entry, gsf_tensor* out) {
    memset(out, 0, sizeof *out);
    if (entry->type != GSF_JSON_OBJECT) return gsf__nn_entry_fail(h, entry, entry, GSF_ERROR_FORMAT, "no object");
    if (strlen(entry->key) != entry->key_size)
        return gsf__nn_entry_fail(h, entry, entry, GSF_ERROR_FORMAT, "a zero byte in its name");
    GSF__TRY(gsf__nn_read_dtype(h, entry, out));
    GSF__TRY(gsf__nn_read_shape(h, entry, out));
    return gsf__nn_read_place(h, entry, out);
}

static gsf_result gsf__nn_check_metadata(const gsf__nn_header* h, const gsf_json_value* metadata) {
    int ok = metadata->type == GSF_JSON_OBJECT;
    for (uint32_t i = metadata->child; ok && i; i = h->json.values[i].next)
        ok = h->json.values[i].type == GSF_JSON_STRING;
    return ok ? GSF_OK : gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%u: __metadata__ does not map names to texts", h->name,
                                  (unsigned)metadata->offset);
}

static uint64_t gsf__nn_bytes(const gsf_tensor* tensor) {
    return (uint64_t)tensor->count * gsf_nn_dtype_size(tensor->dtype);
}

static int gsf__nn_compare_places(const void* a, const void* b) { // an empty tensor before what begins where it stands
    const gsf_tensor *x = (const gsf_tensor*)a, *y = (const gsf_tensor*)b;
    if (x->data != y->data) return (const char*)x->data < (const char*)y->data ? -1 : 1;
    return gsf__nn_bytes(x) < gsf__nn_bytes(y) ? -1 : gsf__nn_bytes(x) > gsf__nn_bytes(y);
}

static int gsf__nn_compare_names(const void* a, const void* b) {
    return strcmp(((const gsf_tensor*)a)->name, ((const gsf_tensor*)b)->name);
}

static gsf_result gsf__nn_check_cover(const gsf__nn_header* h, gsf_tensor* tensors, size_t count) {
    const char* next = h->data;
    const char* const end = h->data + h->data_size;
    if (count) qsort(tensors, count, sizeof *tensors, gsf__nn_compare_places);
    for (size_t i = 0; i < count; i++) {
        const char* begin = (const char*)tensors[i].data;
        if (begin != next)
            return gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%zu: tensor %s %s", h->name, (size_t)(begin - h->text),
                            gsf__nn_show(tensors[i].name).text,
                            begin < next ? "overlaps the one before it" : "follows bytes of no tensor");
        next = begin + gsf__nn_bytes(&tensors[i]);
    }
    if (next != end)
        return gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%zu: %zu bytes belong to no tensor", h->name, (size_t)(next - h->text),
                        (size_t)(end - next));
    return GSF_OK;
}

// Adds the tensors of a parsed header. Their names are copied to the file's block.
static gsf_result gsf__nn_read_entries(gsf__nn_header* h, gsf_nn_weights* weights, gsf__nn_file* file) {
    gsf__nn_files* files = (gsf__nn_files*)weights->files;
    const gsf_json_value* root = &h->json.values[0];
    const size_t first = weights->tensor_count;
    size_t names = 1; // so that there always is a block
    if (root->type != GSF_JSON_OBJECT)
        return gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%d: the header is no object", h->name, (int)GSF__NN_FILE_HEAD);
    for (uint32_t i = root->child; i; i = h->json.values[i].next) names += h->json.values[i].key_size + 1;
    file->names = (char*)gsf_alloc(h->ctx, names, 1);
    if (!file->names) return GSF_ERROR_OUT_OF_MEMORY;
    GSF__TRY(gsf__reserve(h->ctx, (void**)&weights->tensors, &files->tensor_capacity, first, first + root->count,
                          sizeof *weights->tensors));
    for (uint32_t i = root->child; i; i = h->json.values[i].next) {
        const gsf_json_value* entry = &h->json.values[i];
        if (entry->key_size == 12 && memcmp(entry->key, "__metadata__", 12) == 0) {
            GSF__TRY(gsf__nn_check_metadata(h, entry));
            continue;
        }
        gsf_tensor* tensor = &weights->tensors[weights->tensor_count];
        GSF__TRY(gsf__nn_read_entry(h, entry, tensor));
        tensor->name = file->names + file->names_size;
        memcpy(file->names + file->names_size, entry->key, entry->key_size + 1);
        file->names_size += entry->key_size + 1;
        weights->tensor_count++;
    }
    return gsf__nn_check_cover(h, weights->tensors + first, weights->tensor_count - first);
}

static gsf_result gsf__nn_read_header(gsf_context* ctx, const char* name, gsf_nn_weights* weights, gsf__nn_file* file) {
    gsf__nn_header h;
    memset(&h, 0, sizeof h);
    h.ctx = ctx;
    h.name = gsf__nn_path_end(name);
    h.text = (const char*)file->data;
    if (file->size < GSF__NN_FILE_HEAD)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: %zu bytes are no safetensors file", h.name, file->size);
    const uint64_t size = gsf__load_le(file->data, GSF__NN_FILE_HEAD);
    if (size > GSF__NN_HEADER_MAX || size > file->size - GSF__NN_FILE_HEAD)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: a header of %llu bytes in a file of %zu (at most %d)", h.name,
                        (unsigned long long)size, file->size, (int)GSF__NN_HEADER_MAX);
    const size_t end = GSF__NN_FILE_HEAD + (size_t)size;
    if (size == 0 || file->data[GSF__NN_FILE_HEAD] != '{')
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%d: the header does not begin with '{'", h.name,
                        (int)GSF__NN_FILE_HEAD);
    h.data = h.text + end;
    h.data_size = file->size - end;
    GSF__TRY(gsf__parse_json_from(ctx, h.name, h.text, end, GSF__NN_FILE_HEAD, &h.json));
    const gsf_result result = gsf__nn_read_entries(&h, weights, file);
    gsf_destroy_json(ctx, &h.json);
    return result;
}

// ---- files and folders

static void gsf__nn_release(gsf_context* ctx, const unsigned char* data, size_t size, gsf__nn_holder holder) {
    if (holder == GSF__NN_READ) gsf_free(ctx, (void*)(uintptr_t)data);
    if (holder == GSF__NN_MAPPED) gsf__nn_unmap(data, size);
}

// Takes over the bytes, also on failure.
static gsf_result gsf__nn_add_bytes(gsf_context* ctx, const char* name, const unsigned char* data, size_t size,
                                    gsf__nn_holder holder, gsf_nn_weights* weights) {
    gsf__nn_files* files = (gsf__nn_files*)weights->files;
    const gsf_result result = gsf__reserve(ctx, (void**)&files->files, &files->capacity, files->count, files->count + 1,
                                           sizeof *files->files);
    if (result != GSF_OK) {
        gsf__nn_release(ctx, data, size, holder);
        return result;
    }
    gsf__nn_file* file = &files->files[files->count++];
    memset(file, 0, sizeof *file);
    file->data = data;
    file->size = size;
    file->holder = holder;
    if (holder == GSF__NN_MAPPED) weights->mapped_bytes += size;
    if (holder == GSF__NN_READ) weights->read_bytes += size;
    return gsf__nn_read_header(ctx, name, weights, file);
}

static gsf_result gsf__nn_add_file(gsf_context* ctx, const char* path, gsf_nn_weights* weights) {
    const unsigned char* mapping = NULL;
    void* data = NULL;
    size_t size = 0;
    if (gsf__io_is_default(ctx)) GSF__TRY(gsf__nn_map(ctx, path, &mapping, &size));
    if (mapping) return gsf__nn_add_bytes(ctx, path, mapping, size, GSF__NN_MAPPED, weights);
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    return gsf__nn_add_bytes(ctx, path, (const unsigned char*)data, size, GSF__NN_READ, weights);
}

// A shard's name must stay inside the index's folder.
static int gsf__nn_is_plain_name(const gsf_json_value* value) {
    return value->type == GSF_JSON_STRING && value->string_size > 0 && strlen(value->string) == value->string_size &&
           !strpbrk(value->string, "/\\:") && value->string[0] != '.';
}

typedef struct gsf__nn_index { // weight_map of a sharded model while it is read
    gsf_context* ctx;
    const char* name;
    size_t folder_size;       // the shards' names follow this many bytes of `path`
    gsf_text path;
    gsf_json json;
    const gsf_json_value* map;
    const char** shards;      // names of the opened files, in the order of gsf__nn_files
    size_t shard_capacity;
} gsf__nn_index;

static gsf_result gsf__nn_open_shards(gsf__nn_index* index, gsf_nn_weights* weights) {
    const gsf__nn_files* files = (const gsf__nn_files*)weights->files;
    for (uint32_t i = index->map->child; i; i = index->json.values[i].next) {
        const gsf_json_value* value = &index->json.values[i];
        if (!gsf__nn_is_plain_name(value))
            return gsf_fail(index->ctx, GSF_ERROR_FORMAT, "%s:%u: tensor %s: no plain file name", index->name,
                            (unsigned)value->offset, gsf__nn_show(value->key).text);
        size_t k = files->count; // from the latest: mostly that one
        while (k > 0 && strcmp(index->shards[k - 1], value->string) != 0) k--;
        if (k > 0) continue;
        GSF__TRY(gsf__reserve(index->ctx, (void**)&index->shards, &index->shard_capacity, files->count, files->count + 1,
                              sizeof *index->shards));
        index->shards[files->count] = value->string;
        index->path.size = index->folder_size;
        gsf_text_append(index->ctx, &index->path, value->string, value->string_size);
        if (index->path.failed) return GSF_ERROR_OUT_OF_MEMORY;
        GSF__TRY(gsf__nn_add_file(index->ctx, index->path.data, weights));
    }
    return GSF_OK;
}

static gsf_result gsf__nn_sort_names(gsf_context* ctx, gsf_nn_weights* weights) {
    if (weights->tensor_count)
        qsort(weights->tensors, weights->tensor_count, sizeof *weights->tensors, gsf__nn_compare_names);
    for (size_t i = 1; i < weights->tensor_count; i++)
        if (strcmp(weights->tensors[i - 1].name, weights->tensors[i].name) == 0)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: tensor %s stands in two shards", weights->name,
                            gsf__nn_show(weights->tensors[i].name).text);
    return GSF_OK;
}

// Every tensor of the map must have come from the file that the map says.
static gsf_result gsf__nn_check_index(const gsf__nn_index* index, const gsf_nn_weights* weights) {
    const gsf__nn_files* files = (const gsf__nn_files*)weights->files;
    for (uint32_t i = index->map->child; i; i = index->json.values[i].next) {
        const gsf_json_value* value = &index->json.values[i];
        const gsf_tensor* tensor = gsf_nn_find_tensor(weights, value->key);
        if (!tensor || strlen(value->key) != value->key_size)
            return gsf_fail(index->ctx, GSF_ERROR_FORMAT, "%s:%u: tensor %s is not in %s", index->name,
                            (unsigned)value->offset, gsf__nn_show(value->key).text, gsf__nn_show(value->string).text);
        size_t k = 0;
        while ((uintptr_t)tensor->name - (uintptr_t)files->files[k].names >= files->files[k].names_size) k++;
        if (strcmp(index->shards[k], value->string) != 0)
            return gsf_fail(index->ctx, GSF_ERROR_FORMAT, "%s:%u: tensor %s is in %s, not in %s", index->name,
                            (unsigned)value->offset, gsf__nn_show(value->key).text, gsf__nn_show(index->shards[k]).text,
                            gsf__nn_show(value->string).text);
    }
    return GSF_OK;
}

static gsf_result gsf__nn_read_index(gsf_context* ctx, const char* path, const void* data, size_t size,
                                     gsf_nn_weights* weights) {
    gsf__nn_index index;
    memset(&index, 0, sizeof index);
    index.ctx = ctx;
    index.name = gsf__nn_path_end(path);
    gsf_result result = gsf_parse_json(ctx, index.name, (const char*)data, size, &index.json);
    if (result != GSF_OK) return result;
    index.map = gsf_json_member(&index.json, &index.json.values[0], "weight_map");
    if (!index.map || index.map->type != GSF_JSON_OBJECT) {
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: no \"weight_map\" object", index.name);
    } else {
        const char* slash = strrchr(path, '/');
        index.folder_size = slash ? (size_t)(slash - path) + 1 : 0;
        gsf_text_append(ctx, &index.path, path, index.folder_size);
        result = gsf__nn_open_shards(&index, weights);
        if (result == GSF_OK) result = gsf__nn_sort_names(ctx, weights);
        if (result == GSF_OK) result = gsf__nn_check_index(&index, weights);
    }
    gsf_free(ctx, (void*)index.shards);
    gsf_destroy_text(ctx, &index.path);
    gsf_destroy_json(ctx, &index.json);
    return result;
}

// Ends a stretch without the log hook, in which a file was allowed to be absent.
static gsf_result gsf__nn_end_quiet(gsf_context* ctx, const gsf_logger* logger, gsf_result result) {
    ctx->logger = *logger;
    if (result != GSF_OK && result != GSF_ERROR_IO) gsf_log(ctx, GSF_LOG_ERROR, "%s", ctx->error);
    return result;
}

// Opens <path>.index.json, else <path>. *found 0: neither is there, which is an error unless `may_lack`.
static gsf_result gsf__nn_open_either(gsf_context* ctx, gsf_text* path, int may_lack, int* found, gsf_nn_weights* weights) {
    const gsf_logger logger = ctx->logger;
    const size_t plain = path->size;
    void* data = NULL;
    size_t size;
    gsf_text_append(ctx, path, ".index.json", 11);
    if (path->failed) return GSF_ERROR_OUT_OF_MEMORY;
    memset(&ctx->logger, 0, sizeof ctx->logger);
    gsf_result result = gsf__nn_end_quiet(ctx, &logger, gsf_read_file(ctx, path->data, &data, &size));
    *found = result == GSF_OK;
    if (*found) {
        result = gsf__nn_read_index(ctx, path->data, data, size, weights);
        gsf_free(ctx, data);
        return result;
    }
    if (result != GSF_ERROR_IO) return result;
    path->data[plain] = 0;
    if (may_lack) memset(&ctx->logger, 0, sizeof ctx->logger);
    result = gsf__nn_add_file(ctx, path->data, weights);
    if (may_lack) (void)gsf__nn_end_quiet(ctx, &logger, result);
    *found = result == GSF_OK;
    if (result == GSF_OK) return gsf__nn_sort_names(ctx, weights);
    return may_lack && result == GSF_ERROR_IO ? GSF_OK : result;
}

static gsf_result gsf__nn_open_named(gsf_context* ctx, const char* folder, const char* name, int may_lack, int* found,
                                     gsf_nn_weights* weights) {
    gsf_text path;
    memset(&path, 0, sizeof path);
    gsf_text_printf(ctx, &path, "%s%s%s.safetensors", folder, gsf__nn_ends_in(folder, "/") ? "" : "/", name);
    const gsf_result result =
        path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf__nn_open_either(ctx, &path, may_lack, found, weights);
    gsf_destroy_text(ctx, &path);
    return result;
}

// Without a prefix: the folder's only index, else its only file; where folders cannot be listed, the usual names.
static gsf_result gsf__nn_open_folder(gsf_context* ctx, const char* folder, gsf_nn_weights* weights) {
    static const char* const suffixes[] = {".safetensors.index.json", ".safetensors"};
    static const char* const usual[] = {"diffusion_pytorch_model", "model"};
    gsf_result result = GSF_OK;
    int found = 0;
    if (!gsf__io_is_default(ctx) || gsf__nn_look_at_path(folder) == GSF__NN_UNKNOWN) {
        for (size_t i = 0; i < GSF__COUNT(usual) && result == GSF_OK && !found; i++)
            result = gsf__nn_open_named(ctx, folder, usual[i], 1, &found, weights);
    }
    for (size_t i = 0; i < GSF__COUNT(suffixes) && result == GSF_OK && !found; i++) {
        if (!gsf__io_is_default(ctx)) break;
        gsf__nn_listing listing;
        memset(&listing, 0, sizeof listing);
        listing.folder = folder;
        listing.suffix = suffixes[i];
        result = gsf__nn_list_folder(ctx, &listing);
        if (result == GSF_OK && listing.found.size) {
            listing.found.data[listing.found.size - strlen(suffixes[i])] = 0;
            result = gsf__nn_open_named(ctx, folder, listing.found.data, 0, &found, weights);
        }
        gsf_destroy_text(ctx, &listing.found);
    }
    if (result == GSF_OK && !found) return gsf_fail(ctx, GSF_ERROR_IO, "%s: no .safetensors file in it", folder);
    return result;
}

static gsf_result gsf__nn_begin_weights(gsf_context* ctx, const char* name, gsf_nn_weights* out) {
    memset(out, 0, sizeof *out);
    const size_t size = strlen(name), room = sizeof out->name - 1;
    snprintf(out->name, sizeof out->name, "%s", size > room ? name + (size - room) : name);
    out->files = gsf_alloc_zeroed(ctx, 1, sizeof(gsf__nn_files));
    return out->files ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

static gsf_result gsf__nn_open_index_file(gsf_context* ctx, const char* path, gsf_nn_weights* out) {
    void* data;
    size_t size;
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    const gsf_result result = gsf__nn_read_index(ctx, path, data, size, out);
    gsf_free(ctx, data);
    return result;
}

GSF_API gsf_result gsf_nn_open_weights(gsf_context* ctx, const char* path, const char* prefix, gsf_nn_weights* out) {
    gsf_result result = gsf__nn_begin_weights(ctx, path, out);
    if (result != GSF_OK) return result;
    const gsf__nn_path_kind kind = gsf__io_is_default(ctx) ? gsf__nn_look_at_path(path) : GSF__NN_UNKNOWN;
    int found;
    if (kind != GSF__NN_IS_FOLDER && gsf__nn_ends_in(path, ".index.json")) {
        result = gsf__nn_open_index_file(ctx, path, out);
    } else if (kind == GSF__NN_IS_FILE || (kind == GSF__NN_UNKNOWN && gsf__nn_ends_in(path, ".safetensors"))) {
        result = gsf__nn_add_file(ctx, path, out);
        if (result == GSF_OK) result = gsf__nn_sort_names(ctx, out);
    } else if (prefix) {
        result = gsf__nn_open_named(ctx, path, prefix, 0, &found, out);
    } else {
        result = gsf__nn_open_folder(ctx, path, out);
    }
    if (result != GSF_OK) gsf_nn_close_weights(ctx, out);
    return result;
}

GSF_API gsf_result gsf_nn_open_weights_memory(gsf_context* ctx, const char* name, const void* data, size_t size,
                                              gsf_nn_weights* out) {
    gsf_result result = gsf__nn_begin_weights(ctx, name, out);
    if (result == GSF_OK) result = gsf__nn_add_bytes(ctx, name, (const unsigned char*)data, size, GSF__NN_BORROWED, out);
    if (result == GSF_OK) result = gsf__nn_sort_names(ctx, out);
    if (result != GSF_OK) gsf_nn_close_weights(ctx, out);
    return result;
}

GSF_API void gsf_nn_close_weights(gsf_context* ctx, gsf_nn_weights* weights) {
    gsf__nn_files* files = (gsf__nn_files*)weights->files;
    for (size_t i = 0; files && i < files->count; i++) {
        gsf__nn_release(ctx, files->files[i].data, files->files[i].size, files->files[i].holder);
        gsf_free(ctx, files->files[i].names);
    }
    if (files) gsf_free(ctx, files->files);
    gsf_free(ctx, files);
    gsf_free(ctx, weights->tensors);
    memset(weights, 0, sizeof *weights);
}

GSF_API const gsf_tensor* gsf_nn_find_tensor(const gsf_nn_weights* weights, const char* name) {
    size_t low = 0, high = weights->tensor_count;
    while (low < high) {
        const size_t middle = low + (high - low) / 2;
        const int order = strcmp(weights->tensors[middle].name, name);
        if (order == 0) return &weights->tensors[middle];
        if (order < 0) low = middle + 1;
        else high = middle;
    }
    return NULL;
}

// ---- writing

static gsf_result gsf__nn_check_saved(gsf_context* ctx, const gsf_tensor* tensor) {
    const char* name = tensor->name ? tensor->name : "";
    size_t left = strlen(name);
    int64_t count = 1;
    for (const char* p = name; left;) {
        const size_t step = gsf__utf8_size(p, left);
        if (!step) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "tensor %s: name is no UTF-8", gsf__nn_show(name).text);
        p += step;
        left -= step;
    }
    int ok = tensor->name && strcmp(name, "__metadata__") != 0 && gsf_nn_dtype_size(tensor->dtype) != 0 &&
             tensor->rank >= 0 && tensor->rank <= GSF_NN_MAX_RANK;
    for (int32_t i = 0; ok && i < tensor->rank; i++) {
        ok = tensor->shape[i] >= 0 && (tensor->shape[i] == 0 || count <= INT64_MAX / tensor->shape[i]);
        if (ok) count *= tensor->shape[i];
    }
    ok = ok && count == tensor->count && (count == 0 || tensor->data) &&
         (uint64_t)count <= SIZE_MAX / 2 / gsf_nn_dtype_size(tensor->dtype);
    return ok ? GSF_OK : gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "tensor %s: name, dtype, shape, count and data do not fit",
                                  gsf__nn_show(name).text);
}

static int gsf__nn_compare_saved(const void* a, const void* b) { // wide types first, so that all stay aligned
    const gsf_tensor *x = *(const gsf_tensor* const*)a, *y = *(const gsf_tensor* const*)b;
    const size_t p = gsf_nn_dtype_size(x->dtype), q = gsf_nn_dtype_size(y->dtype);
    return p != q ? (p > q ? -1 : 1) : strcmp(x->name, y->name);
}

static int gsf__nn_compare_saved_names(const void* a, const void* b) {
    return strcmp((*(const gsf_tensor* const*)a)->name, (*(const gsf_tensor* const*)b)->name);
}

static gsf_result gsf__nn_format_header(gsf_context* ctx, const gsf_tensor* const* order, size_t count, gsf_text* out) {
    size_t begin = 0;
    gsf_text_append(ctx, out, "        {", 9); // the length goes where the spaces are
    for (size_t i = 0; i < count; i++) {
        const gsf_tensor* t = order[i];
        const size_t bytes = (size_t)gsf__nn_bytes(t);
        if (bytes > SIZE_MAX / 2 - begin) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "the tensors' sizes overflow");
        if (i) gsf_text_append(ctx, out, ",", 1);
        gsf_text_json_string(ctx, out, t->name);
        gsf_text_printf(ctx, out, ":{\"dtype\":\"%s\",\"shape\":[", gsf_nn_dtype_name(t->dtype));
        for (int32_t k = 0; k < t->rank; k++) gsf_text_printf(ctx, out, "%s%lld", k ? "," : "", (long long)t->shape[k]);
        gsf_text_printf(ctx, out, "],\"data_offsets\":[%zu,%zu]}", begin, begin + bytes);
        begin += bytes;
    }
    gsf_text_append(ctx, out, "}", 1);
    gsf_text_append(ctx, out, "       ", (8 - out->size % 8) % 8);
    if (out->failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__store_le(out->data, out->size - GSF__NN_FILE_HEAD, GSF__NN_FILE_HEAD);
    return gsf__reserve(ctx, (void**)&out->data, &out->capacity, out->size, out->size + begin + 1, 1);
}

GSF_API gsf_result gsf_nn_save_tensors(gsf_context* ctx, const char* path, const gsf_tensor* tensors, size_t count) {
    gsf_text out;
    memset(&out, 0, sizeof out);
    for (size_t i = 0; i < count; i++) GSF__TRY(gsf__nn_check_saved(ctx, &tensors[i]));
    const gsf_tensor** order = (const gsf_tensor**)gsf_alloc(ctx, count, sizeof *order);
    if (!order) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < count; i++) order[i] = &tensors[i];
    if (count) qsort((void*)order, count, sizeof *order, gsf__nn_compare_saved_names);
    for (size_t i = 1; i < count && result == GSF_OK; i++)
        if (strcmp(order[i - 1]->name, order[i]->name) == 0)
            result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: tensor %s given twice", path,
                              gsf__nn_show(order[i]->name).text);
    if (count) qsort((void*)order, count, sizeof *order, gsf__nn_compare_saved);
    if (result == GSF_OK) result = gsf__nn_format_header(ctx, order, count, &out);
    for (size_t i = 0; i < count && result == GSF_OK; i++)
        gsf_text_append(ctx, &out, (const char*)order[i]->data, (size_t)gsf__nn_bytes(order[i]));
    if (result == GSF_OK) result = out.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, out.data, out.size);
    gsf_destroy_text(ctx, &out);
    gsf_free(ctx, (void*)order);
    return result;
}

// ---- for the networks: taking tensors one by one, and noticing what is left over

typedef struct gsf__nn_loader {
    gsf_context* ctx;
    const gsf_nn_weights* weights;
    unsigned char* taken; // per tensor
} gsf__nn_loader;

GSF__SHARED gsf_result gsf__nn_begin_loading(gsf_context* ctx, const gsf_nn_weights* weights, gsf__nn_loader* out) {
    out->ctx = ctx;
    out->weights = weights;
    out->taken = (unsigned char*)gsf_alloc_zeroed(ctx, weights->tensor_count, 1);
    return out->taken ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

// "[2, 3, 64]"; a negative size, which stands for any, prints as "?".
static void gsf__nn_print_shape(int32_t rank, const int64_t* shape, char* out, size_t room) {
    size_t at = (size_t)snprintf(out, room, "[");
    for (int32_t i = 0; i < rank && at < room; i++) {
        const char* comma = i ? ", " : "";
        at += (size_t)(shape[i] < 0 ? snprintf(out + at, room - at, "%s?", comma)
                                    : snprintf(out + at, room - at, "%s%lld", comma, (long long)shape[i]));
    }
    if (at < room) snprintf(out + at, room - at, "]");
}

static gsf_result gsf__nn_check_taken(const gsf__nn_loader* loader, const gsf_tensor* t, int32_t rank,
                                      const int64_t* shape) {
    char found[200], wanted[200];
    int ok = t->rank == rank;
    for (int32_t i = 0; ok && i < rank; i++) ok = shape[i] < 0 || t->shape[i] == shape[i];
    if (!ok) {
        gsf__nn_print_shape(t->rank, t->shape, found, sizeof found);
        gsf__nn_print_shape(rank, shape, wanted, sizeof wanted);
        return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensor %s has shape %s, not %s", loader->weights->name,
                        gsf__nn_show(t->name).text, found, wanted);
    }
    if (t->dtype != GSF_NN_F32 && t->dtype != GSF_NN_BF16 && t->dtype != GSF_NN_F16)
        return gsf_fail(loader->ctx, GSF_ERROR_UNSUPPORTED, "%s: tensor %s is %s, not F32, BF16 or F16",
                        loader->weights->name, gsf__nn_show(t->name).text, gsf_nn_dtype_name(t->dtype));
    return GSF_OK;
}

static gsf_result gsf__nn_take(gsf__nn_loader* loader, const char* name, int optional, const gsf_tensor** out,
                               int32_t rank, const int64_t* shape) {
    *out = NULL;
    const gsf_tensor* found = gsf_nn_find_tensor(loader->weights, name);
    if (!found && optional) return GSF_OK;
    if (!found)
        return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensor %s is missing", loader->weights->name,
                        gsf__nn_show(name).text);
    loader->taken[found - loader->weights->tensors] = 1;
    GSF__TRY(gsf__nn_check_taken(loader, found, rank, shape));
    *out = found;
    return GSF_OK;
}

// Finds the tensor of that name (printf style), which must be F32, BF16 or F16 and have exactly this shape; a negative
// size means any.
GSF_PRINTF(5, 6)
GSF__SHARED gsf_result gsf__nn_need(gsf__nn_loader* loader, const gsf_tensor** out, int32_t rank, const int64_t* shape,
                                    const char* format, ...) {
    char name[256];
    va_list args;
    va_start(args, format);
    vsnprintf(name, sizeof name, format, args);
    va_end(args);
    return gsf__nn_take(loader, name, 0, out, rank, shape);
}

// The same for a tensor that may be absent: *out is NULL then.
GSF_PRINTF(5, 6)
GSF__SHARED gsf_result gsf__nn_want(gsf__nn_loader* loader, const gsf_tensor** out, int32_t rank, const int64_t* shape,
                                    const char* format, ...) {
    char name[256];
    va_list args;
    va_start(args, format);
    vsnprintf(name, sizeof name, format, args);
    va_end(args);
    return gsf__nn_take(loader, name, 1, out, rank, shape);
}

// Counts all tensors whose names begin so as taken: parts of a file that the caller has no use for.
GSF__SHARED void gsf__nn_ignore(gsf__nn_loader* loader, const char* prefix) {
    for (size_t i = 0; i < loader->weights->tensor_count; i++)
        if (strncmp(loader->weights->tensors[i].name, prefix, strlen(prefix)) == 0) loader->taken[i] = 1;
}

// Frees the loader. If `result` is GSF_OK but tensors were left over, the error names the first few; else returns it.
GSF__SHARED gsf_result gsf__nn_end_loading(gsf__nn_loader* loader, gsf_result result) {
    enum { NAMED = 3 };
    gsf__nn_shown names[NAMED];
    size_t left = 0;
    memset(names, 0, sizeof names);
    for (size_t i = 0; result == GSF_OK && i < loader->weights->tensor_count; i++)
        if (!loader->taken[i] && left++ < NAMED) names[left - 1] = gsf__nn_show(loader->weights->tensors[i].name);
    gsf_free(loader->ctx, loader->taken);
    loader->taken = NULL;
    if (left == 0) return result;
    return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: %zu tensors that this model does not have: %s%s%s%s%s%s",
                    loader->weights->name, left, names[0].text, left > 1 ? ", " : "", names[1].text, left > 2 ? ", " : "",
                    names[2].text, left > NAMED ? ", ..." : "");
}

// ---- for the networks: config.json. A key that is null counts as absent, as diffusers writes it.

typedef struct gsf__nn_config {
    gsf_context* ctx;
    gsf_json json;
} gsf__nn_config;

static gsf_result gsf__nn_check_config(gsf__nn_config* config) {
    if (config->json.values[0].type == GSF_JSON_OBJECT) return GSF_OK;
    const gsf_result result = gsf_fail(config->ctx, GSF_ERROR_FORMAT, "%s:0: no object", config->json.name);
    gsf_destroy_json(config->ctx, &config->json);
    return result;
}

GSF__SHARED gsf_result gsf__nn_parse_config(gsf_context* ctx, const char* name, const char* text, size_t size,
                                            gsf__nn_config* out) {
    memset(out, 0, sizeof *out);
    out->ctx = ctx;
    GSF__TRY(gsf_parse_json(ctx, gsf__nn_path_end(name), text, size, &out->json));
    return gsf__nn_check_config(out);
}

GSF__SHARED gsf_result gsf__nn_load_config(gsf_context* ctx, const char* path, gsf__nn_config* out) {
    void* data;
    size_t size;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    const gsf_result result = gsf__nn_parse_config(ctx, path, (const char*)data, size, out);
    gsf_free(ctx, data);
    return result;
}

GSF__SHARED void gsf__nn_close_config(gsf__nn_config* config) { gsf_destroy_json(config->ctx, &config->json); }

static const gsf_json_value* gsf__nn_config_find(const gsf__nn_config* config, const char* key) {
    const gsf_json_value* value = gsf_json_member(&config->json, &config->json.values[0], key);
    return value && value->type != GSF_JSON_NULL ? value : NULL;
}

static gsf_result gsf__nn_config_fail(const gsf__nn_config* config, const gsf_json_value* value, const char* key,
                                      const char* wanted) {
    if (!value) return gsf_fail(config->ctx, GSF_ERROR_FORMAT, "%s: %s is missing", config->json.name, key);
    return gsf_fail(config->ctx, GSF_ERROR_FORMAT, "%s:%u: %s is not %s", config->json.name, (unsigned)value->offset, key,
                    wanted);
}

static gsf_result gsf__nn_config_whole(const gsf__nn_config* config, const gsf_json_value* value, const char* key,
                                       int64_t low, int64_t high, int64_t* out) {
    char wanted[80];
    if (value && value->type == GSF_JSON_NUMBER && value->number >= (double)low && value->number <= (double)high &&
        floor(value->number) == value->number) {
        *out = (int64_t)value->number;
        return GSF_OK;
    }
    snprintf(wanted, sizeof wanted, "a whole number from %lld to %lld", (long long)low, (long long)high);
    return gsf__nn_config_fail(config, value, key, wanted);
}

// Whole numbers, |low| and |high| up to 2^53. Here and below the function with `fallback` takes a key that may be absent.
GSF__SHARED gsf_result gsf__nn_config_int(const gsf__nn_config* config, const char* key, int64_t low, int64_t high,
                                          int64_t* out) {
    return gsf__nn_config_whole(config, gsf__nn_config_find(config, key), key, low, high, out);
}

GSF__SHARED gsf_result gsf__nn_config_int_or(const gsf__nn_config* config, const char* key, int64_t fallback, int64_t low,
                                             int64_t high, int64_t* out) {
    const gsf_json_value* value = gsf__nn_config_find(config, key);
    *out = fallback;
    return value ? gsf__nn_config_whole(config, value, key, low, high, out) : GSF_OK;
}

GSF__SHARED gsf_result gsf__nn_config_number(const gsf__nn_config* config, const char* key, double low, double high,
                                             double* out) {
    char wanted[80];
    const gsf_json_value* value = gsf__nn_config_find(config, key);
    if (value && value->type == GSF_JSON_NUMBER && value->number >= low && value->number <= high) {
        *out = value->number;
        return GSF_OK;
    }
    snprintf(wanted, sizeof wanted, "a number from %g to %g", low, high);
    return gsf__nn_config_fail(config, value, key, wanted);
}

GSF__SHARED gsf_result gsf__nn_config_number_or(const gsf__nn_config* config, const char* key, double fallback, double low,
                                                double high, double* out) {
    *out = fallback;
    return gsf__nn_config_find(config, key) ? gsf__nn_config_number(config, key, low, high, out) : GSF_OK;
}

GSF__SHARED gsf_result gsf__nn_config_bool_or(const gsf__nn_config* config, const char* key, int fallback, int* out) {
    const gsf_json_value* value = gsf__nn_config_find(config, key);
    *out = fallback;
    if (!value) return GSF_OK;
    if (value->type != GSF_JSON_TRUE && value->type != GSF_JSON_FALSE)
        return gsf__nn_config_fail(config, value, key, "true or false");
    *out = value->type == GSF_JSON_TRUE;
    return GSF_OK;
}

// *out points into the config, or to the fallback; NULL as fallback: the key must be there.
GSF__SHARED gsf_result gsf__nn_config_string(const gsf__nn_config* config, const char* key, const char* fallback,
                                             const char** out) {
    const gsf_json_value* value = gsf__nn_config_find(config, key);
    *out = fallback;
    if (!value && fallback) return GSF_OK;
    if (!value || value->type != GSF_JSON_STRING) return gsf__nn_config_fail(config, value, key, "a text");
    *out = value->string;
    return GSF_OK;
}

// Between 1 and `room` whole numbers.
GSF__SHARED gsf_result gsf__nn_config_ints(const gsf__nn_config* config, const char* key, int64_t low, int64_t high,
                                           size_t room, int64_t* out, size_t* count) {
    const gsf_json_value* value = gsf__nn_config_find(config, key);
    char wanted[80];
    *count = 0;
    if (!value || value->type != GSF_JSON_ARRAY || value->count < 1 || value->count > room) {
        snprintf(wanted, sizeof wanted, "a list of 1 to %zu whole numbers", room);
        return gsf__nn_config_fail(config, value, key, wanted);
    }
    for (uint32_t i = value->child; i; i = config->json.values[i].next)
        GSF__TRY(gsf__nn_config_whole(config, &config->json.values[i], key, low, high, &out[(*count)++]));
    return GSF_OK;
}

// ---- >>nn vector: exp and friends, eight at a time --------------------------------

// ---- >>nn activations -----------------------------------------------------------

static float gsf__nn_activation_ref(gsf_nn_activation activation, float x) {
    switch (activation) {
        case GSF_NN_LINEAR: return x;
        case GSF_NN_GELU_TANH: { // x/2 (1 + tanh(u)) = x / (1 + exp(-2u))
            if (x < -12.0f) return -0.0f * (x == x); // below float's resolution of the limit, and no inf * 0
            const float u = 0.7978845608028654f * (x + 0.044715f * x * x * x);
            return x / (1.0f + expf(-2.0f * u));
        }
        case GSF_NN_SILU: return x < -104.0f ? -0.0f : x / (1.0f + expf(-x));
    }
    return x;
}

typedef struct gsf__activate_job {
    gsf_nn_activation activation;
    const float* x;
    float* y;
    int64_t count;
} gsf__activate_job;

enum { GSF__NN_CHUNK = 1 << 16 }; // values per chunk of elementwise work

static void gsf__activate_chunk(void* arg, size_t chunk, int worker) {
    const gsf__activate_job* job = (const gsf__activate_job*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * GSF__NN_CHUNK;
    const int64_t end = begin + GSF__NN_CHUNK < job->count ? begin + GSF__NN_CHUNK : job->count;
    for (int64_t i = begin; i < end; i++) job->y[i] = gsf__nn_activation_ref(job->activation, job->x[i]);
}

GSF_API void gsf_nn_activate(gsf_context* ctx, gsf_nn_activation activation, const float* x, int64_t count, float* y) {
    gsf__activate_job job = {activation, x, y, count};
    gsf__parallel_for(ctx, (size_t)((count + GSF__NN_CHUNK - 1) / GSF__NN_CHUNK), gsf__activate_chunk, &job);
}

typedef struct gsf__softmax_job {
    const float* x;
    float* y;
    int64_t columns;
    float scale;
} gsf__softmax_job;

static void gsf__softmax_row(void* arg, size_t row, int worker) {
    const gsf__softmax_job* job = (const gsf__softmax_job*)arg;
    (void)worker;
    const float* x = job->x + (int64_t)row * job->columns;
    float* y = job->y + (int64_t)row * job->columns;
    float top = -FLT_MAX, sum = 0.0f;
    for (int64_t i = 0; i < job->columns; i++)
        if (job->scale * x[i] > top) top = job->scale * x[i];
    for (int64_t i = 0; i < job->columns; i++) sum += y[i] = expf(job->scale * x[i] - top);
    for (int64_t i = 0; i < job->columns; i++) y[i] /= sum;
}

GSF_API void gsf_nn_softmax(gsf_context* ctx, const float* x, int64_t rows, int64_t columns, float scale, float* y) {
    gsf__softmax_job job = {x, y, columns, scale};
    gsf__parallel_for(ctx, (size_t)rows, gsf__softmax_row, &job);
}

// ---- >>nn linear ----------------------------------------------------------------

typedef struct gsf__linear_job {
    gsf_nn_linear_desc desc;
    int64_t in, out, tasks;
    float* scratch; // one widened row of the weights for each worker
} gsf__linear_job;

static gsf_result gsf__check_linear(gsf_context* ctx, const gsf_nn_linear_desc* desc, int64_t* in, int64_t* out) {
    const gsf_tensor* w = desc->weight;
    if (!desc->x || !desc->y || !w || desc->rows < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: x, y or weight is missing");
    if (w->rank < 2 || w->shape[0] < 1 || w->count / w->shape[0] < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: %s is no matrix", w->name);
    if (w->dtype != GSF_NN_F32 && w->dtype != GSF_NN_BF16 && w->dtype != GSF_NN_F16)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "linear: %s is %s", w->name, gsf_nn_dtype_name(w->dtype));
    *out = w->shape[0];
    *in = w->count / w->shape[0];
    if (desc->bias && desc->bias->count != *out)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: %s has %lld values, not %lld", desc->bias->name,
                        (long long)desc->bias->count, (long long)*out);
    return GSF_OK;
}

static void gsf__linear_column(void* arg, size_t column, int worker) { // one output of all rows
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const gsf_nn_linear_desc* d = &job->desc;
    float* w = job->scratch + worker * job->in;
    float b = 0.0f;
    gsf_nn_read_tensor(d->weight, (int64_t)column * job->in, job->in, w);
    if (d->bias) gsf_nn_read_tensor(d->bias, (int64_t)column, 1, &b);
    for (int64_t m = 0; m < d->rows; m++) {
        float sum = 0.0f;
        for (int64_t k = 0; k < job->in; k++) sum += d->x[m * d->ldx + k] * w[k];
        float* y = &d->y[m * d->ldy + (int64_t)column];
        const float value = gsf__nn_activation_ref(d->activation, sum + b);
        *y = d->gate ? *y + d->gate[column] * value : d->accumulate ? *y + value : value;
    }
}

GSF_API gsf_result gsf_nn_linear(gsf_context* ctx, gsf_nn_workspace* workspace, const gsf_nn_linear_desc* desc) {
    gsf_nn_workspace own;
    gsf__linear_job job;
    memset(&own, 0, sizeof own);
    memset(&job, 0, sizeof job);
    GSF__TRY(gsf__check_linear(ctx, desc, &job.in, &job.out));
    job.desc = *desc;
    if (!job.desc.ldx) job.desc.ldx = job.in;
    if (!job.desc.ldy) job.desc.ldy = job.out;
    job.scratch = (float*)gsf__nn_scratch(ctx, workspace ? workspace : &own,
                                          (size_t)ctx->parallel.worker_count * (size_t)job.in * sizeof(float));
    if (!job.scratch) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__parallel_for(ctx, (size_t)job.out, gsf__linear_column, &job);
    gsf_nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn norms -----------------------------------------------------------------

typedef struct gsf__norm_job {
    const float *x, *weight, *bias, *scale, *shift, *cos, *sin;
    float* y;
    int64_t rows, dim, stride, groups, rope_first;
    int32_t heads;
    float eps;
    int centre; // 0: root mean square only
} gsf__norm_job;

enum { GSF__NORM_ROWS = 16 }; // rows per chunk

static void gsf__norm_row(const gsf__norm_job* job, const float* x, float* y) {
    double mean = 0.0, square = 0.0;
    if (job->centre) {
        for (int64_t i = 0; i < job->dim; i++) mean += (double)x[i];
        mean /= (double)job->dim;
    }
    for (int64_t i = 0; i < job->dim; i++) square += ((double)x[i] - mean) * ((double)x[i] - mean);
    const double inverse = 1.0 / sqrt(square / (double)job->dim + (double)job->eps);
    for (int64_t i = 0; i < job->dim; i++) {
        float v = (float)(((double)x[i] - mean) * inverse);
        if (job->weight) v *= job->weight[i];
        if (job->bias) v += job->bias[i];
        if (job->scale) v = v * (1.0f + job->scale[i]) + job->shift[i];
        y[i] = v;
    }
}

static void gsf__norm_chunk(void* arg, size_t chunk, int worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * GSF__NORM_ROWS;
    for (int64_t r = begin; r < begin + GSF__NORM_ROWS && r < job->rows; r++)
        gsf__norm_row(job, job->x + r * job->dim, job->y + r * job->dim);
}

static void gsf__norm_rows(gsf_context* ctx, gsf__norm_job* job) {
    gsf__parallel_for(ctx, (size_t)((job->rows + GSF__NORM_ROWS - 1) / GSF__NORM_ROWS), gsf__norm_chunk, job);
}

GSF_API void gsf_nn_layer_norm_modulated(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight,
                                         const float* bias, float eps, const float* scale, const float* shift, float* y) {
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.y = y;
    job.rows = rows;
    job.dim = dim;
    job.weight = weight;
    job.bias = bias;
    job.scale = scale;
    job.shift = shift;
    job.eps = eps;
    job.centre = 1;
    gsf__norm_rows(ctx, &job);
}

GSF_API void gsf_nn_layer_norm(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight,
                               const float* bias, float eps, float* y) {
    gsf_nn_layer_norm_modulated(ctx, x, rows, dim, weight, bias, eps, NULL, NULL, y);
}

GSF_API void gsf_nn_rms_norm(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight, float eps,
                             float* y) {
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.y = y;
    job.rows = rows;
    job.dim = dim;
    job.weight = weight;
    job.eps = eps;
    gsf__norm_rows(ctx, &job);
}

static void gsf__group_norm_group(void* arg, size_t group, int worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg; // rows: channels; dim: values of a channel
    (void)worker;
    const int64_t per = job->rows / job->groups, count = per * job->dim;
    const float* x = job->x + (int64_t)group * count;
    float* y = job->y + (int64_t)group * count;
    double mean = 0.0, square = 0.0;
    for (int64_t i = 0; i < count; i++) mean += (double)x[i];
    mean /= (double)count;
    for (int64_t i = 0; i < count; i++) square += ((double)x[i] - mean) * ((double)x[i] - mean);
    const double inverse = 1.0 / sqrt(square / (double)count + (double)job->eps);
    for (int64_t i = 0; i < count; i++) {
        const int64_t channel = (int64_t)group * per + i / job->dim;
        float v = (float)(((double)x[i] - mean) * inverse);
        if (job->weight) v *= job->weight[channel];
        if (job->bias) v += job->bias[channel];
        y[i] = v;
    }
}

GSF_API void gsf_nn_group_norm(gsf_context* ctx, const float* x, int64_t channels, int64_t count, int64_t groups,
                               const float* weight, const float* bias, float eps, float* y) {
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.y = y;
    job.rows = channels;
    job.dim = count;
    job.groups = groups;
    job.weight = weight;
    job.bias = bias;
    job.eps = eps;
    gsf__parallel_for(ctx, (size_t)groups, gsf__group_norm_group, &job);
}

static void gsf__head_norm_rope_row(void* arg, size_t row, int worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    const int64_t token = (int64_t)row - job->rope_first;
    for (int32_t h = 0; h < job->heads; h++) {
        float* x = job->y + (int64_t)row * job->stride + h * job->dim;
        gsf__norm_row(job, x, x);
        if (!job->cos || token < 0) continue;
        const float *c = job->cos + token * job->dim, *s = job->sin + token * job->dim;
        for (int64_t i = 0; i + 1 < job->dim; i += 2) {
            const float a = x[i], b = x[i + 1];
            x[i] = a * c[i] - b * s[i];
            x[i + 1] = b * c[i + 1] + a * s[i + 1];
        }
    }
}

GSF_API void gsf_nn_head_norm_rope(gsf_context* ctx, float* x, int64_t rows, int64_t ldx, int32_t heads, int32_t head_dim,
                                   const float* weight, const float* bias, float eps, const float* cos, const float* sin,
                                   int64_t rope_first) {
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    job.y = x;
    job.rows = rows;
    job.stride = ldx ? ldx : (int64_t)heads * head_dim;
    job.dim = head_dim;
    job.heads = heads;
    job.weight = weight;
    job.bias = bias;
    job.eps = eps;
    job.centre = 1;
    job.cos = cos;
    job.sin = sin;
    job.rope_first = rope_first;
    gsf__parallel_for(ctx, (size_t)rows, gsf__head_norm_rope_row, &job);
}

// ---- >>nn attention -------------------------------------------------------------

typedef struct gsf__attention_job {
    gsf_nn_attention_desc desc;
    float* scratch; // per worker: one row of logits
} gsf__attention_job;

static void gsf__attention_row(void* arg, size_t row, int worker) {
    const gsf__attention_job* job = (const gsf__attention_job*)arg;
    const gsf_nn_attention_desc* d = &job->desc;
    float *p = job->scratch + worker * (d->keys + d->head_dim), *sum = p + d->keys;
    for (int32_t h = 0; h < d->heads; h++) {
        const float* q = d->q + (int64_t)row * d->ldq + (int64_t)h * d->head_dim;
        const unsigned char* mask = d->mask ? d->mask + (h * d->queries + (int64_t)row) * d->keys : NULL;
        float top = -FLT_MAX, total = 0.0f;
        for (int64_t j = 0; j < d->keys; j++) {
            const float* k = d->k + j * d->ldk + (int64_t)h * d->head_dim;
            float dot = 0.0f;
            for (int32_t i = 0; i < d->head_dim; i++) dot += q[i] * k[i];
            p[j] = dot * d->scale;
            if ((!mask || mask[j]) && p[j] > top) top = p[j];
        }
        for (int32_t i = 0; i < d->head_dim; i++) sum[i] = 0.0f;
        for (int64_t j = 0; j < d->keys; j++) {
            if (mask && !mask[j]) continue;
            const float* v = d->v + j * d->ldv + (int64_t)h * d->head_dim;
            const float weight = expf(p[j] - top);
            total += weight;
            for (int32_t i = 0; i < d->head_dim; i++) sum[i] += weight * v[i];
        }
        float* out = d->out + (int64_t)row * d->ldo + (int64_t)h * d->head_dim;
        for (int32_t i = 0; i < d->head_dim; i++) out[i] = total == 0.0f ? 0.0f : sum[i] / total; // NaN goes through
    }
}

GSF_API gsf_result gsf_nn_attention(gsf_context* ctx, gsf_nn_workspace* workspace, const gsf_nn_attention_desc* desc) {
    gsf_nn_workspace own;
    gsf__attention_job job;
    memset(&own, 0, sizeof own);
    job.desc = *desc;
    gsf_nn_attention_desc* d = &job.desc;
    if (!d->q || !d->k || !d->v || !d->out || d->queries < 0 || d->keys < 1 || d->heads < 1 || d->head_dim < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "attention: a tensor or a size is missing");
    const int64_t width = (int64_t)d->heads * d->head_dim;
    if (!d->ldq) d->ldq = width;
    if (!d->ldk) d->ldk = width;
    if (!d->ldv) d->ldv = width;
    if (!d->ldo) d->ldo = width;
    if (d->scale == 0.0f) d->scale = 1.0f / sqrtf((float)d->head_dim);
    job.scratch = (float*)gsf__nn_scratch(ctx, workspace ? workspace : &own,
                                          (size_t)ctx->parallel.worker_count * (size_t)(d->keys + d->head_dim) * sizeof(float));
    if (!job.scratch) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__parallel_for(ctx, (size_t)d->queries, gsf__attention_row, &job);
    gsf_nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn convolution -----------------------------------------------------------

// Channels-last, a convolution of 3 x 3 (x 3) is 3 (9) matrix products: the 3C values left of, at and right of a pixel lie
// together, so for each kernel row (kt, ky) a row of output pixels is A (pixels, 3C), whose rows overlap by 2C, times
// B (3C, outputs). Frames get a column of zeros at either side for that; rows above and below the frame are skipped.
// Work is cut into segments of 4 x 30 output pixels. A segment goes through 16 outputs at a time: their weights are
// packed as (kernel row, 3C, 16), cut into panels of up to 256 values x 16 (16 KiB, first level cache), and each panel is
// multiplied with all pixels of the segment, 6 pixels x 16 outputs in registers.

enum {
    GSF__CONV_M = 6, GSF__CONV_N = 16, GSF__CONV_K = 256, // pixels, outputs, values of a product
    GSF__CONV_ROWS = 4, GSF__CONV_COLUMNS = 30,           // pixels of a segment; columns: a multiple of CONV_M
    GSF__CONV_TAPS = 27,
};

typedef struct gsf__conv_kernels {
    // c += a b. a: `count` pixels, lda apart, k values each; b: (k, 16); c: (count rounded up to 6, 16), whose last rows
    // repeat the last pixel.
    void (*multiply)(const float* a, int64_t lda, int64_t count, const float* b, int64_t k, float* c);
    // out = c, or out += c, for `count` pixels, ldo apart, and n <= 16 outputs; sums (2, 16) += values and their squares.
    void (*store)(const float* c, int64_t count, int64_t n, int accumulate, float* out, int64_t ldo, double* sums);
    // y = silu((x - mean) * scale + offset)
    void (*norm_silu)(const float* x, int64_t count, const float* mean, const float* scale, const float* offset, float* y);
} gsf__conv_kernels;

static void gsf__conv_multiply_ref(const float* a, int64_t lda, int64_t count, const float* b, int64_t k, float* c) {
    for (int64_t m = 0; m < count; m++)
        for (int n0 = 0; n0 < GSF__CONV_N; n0 += 4) {
            const float* w = b + n0;
            float* y = c + m * GSF__CONV_N + n0;
            float y0 = y[0], y1 = y[1], y2 = y[2], y3 = y[3];
            for (int64_t i = 0; i < k; i++, w += GSF__CONV_N) {
                const float x = a[m * lda + i];
                y0 += x * w[0], y1 += x * w[1], y2 += x * w[2], y3 += x * w[3];
            }
            y[0] = y0, y[1] = y1, y[2] = y2, y[3] = y3;
        }
}

static void gsf__conv_store_ref(const float* c, int64_t count, int64_t n, int accumulate, float* out, int64_t ldo,
                                double* sums) {
    for (int64_t m = 0; m < count; m++)
        for (int64_t i = 0; i < n; i++) {
            float* y = &out[m * ldo + i];
            *y = accumulate ? *y + c[m * GSF__CONV_N + i] : c[m * GSF__CONV_N + i];
            sums[i] += (double)*y;
            sums[GSF__CONV_N + i] += (double)*y * (double)*y;
        }
}

static void gsf__conv_norm_silu_ref(const float* x, int64_t count, const float* mean, const float* scale,
                                    const float* offset, float* y) {
    for (int64_t i = 0; i < count; i++)
        y[i] = gsf__nn_activation_ref(GSF_NN_SILU, (x[i] - mean[i]) * scale[i] + offset[i]);
}

#if GSF__X86
// Six pixels at a time; a missing one reads the last one's values.
GSF__TARGET_AVX2 static void gsf__conv_multiply_avx2(const float* a, int64_t lda, int64_t count, const float* b, int64_t k,
                                                     float* c) {
    for (int64_t m = 0; m < count; m += GSF__CONV_M, a += GSF__CONV_M * lda, c += GSF__CONV_M * GSF__CONV_N) {
        const int64_t last = count - m - 1;
        const float *a0 = a, *a1 = a + (last < 1 ? last : 1) * lda, *a2 = a + (last < 2 ? last : 2) * lda,
                    *a3 = a + (last < 3 ? last : 3) * lda, *a4 = a + (last < 4 ? last : 4) * lda,
                    *a5 = a + (last < 5 ? last : 5) * lda, *w = b;
        __m256 c00 = _mm256_loadu_ps(c), c01 = _mm256_loadu_ps(c + 8), c10 = _mm256_loadu_ps(c + 16),
               c11 = _mm256_loadu_ps(c + 24), c20 = _mm256_loadu_ps(c + 32), c21 = _mm256_loadu_ps(c + 40),
               c30 = _mm256_loadu_ps(c + 48), c31 = _mm256_loadu_ps(c + 56), c40 = _mm256_loadu_ps(c + 64),
               c41 = _mm256_loadu_ps(c + 72), c50 = _mm256_loadu_ps(c + 80), c51 = _mm256_loadu_ps(c + 88);
        for (int64_t i = 0; i < k; i++, w += GSF__CONV_N) {
            const __m256 w0 = _mm256_loadu_ps(w), w1 = _mm256_loadu_ps(w + 8);
            __m256 v = _mm256_broadcast_ss(a0 + i);
            c00 = _mm256_fmadd_ps(v, w0, c00);
            c01 = _mm256_fmadd_ps(v, w1, c01);
            v = _mm256_broadcast_ss(a1 + i);
            c10 = _mm256_fmadd_ps(v, w0, c10);
            c11 = _mm256_fmadd_ps(v, w1, c11);
            v = _mm256_broadcast_ss(a2 + i);
            c20 = _mm256_fmadd_ps(v, w0, c20);
            c21 = _mm256_fmadd_ps(v, w1, c21);
            v = _mm256_broadcast_ss(a3 + i);
            c30 = _mm256_fmadd_ps(v, w0, c30);
            c31 = _mm256_fmadd_ps(v, w1, c31);
            v = _mm256_broadcast_ss(a4 + i);
            c40 = _mm256_fmadd_ps(v, w0, c40);
            c41 = _mm256_fmadd_ps(v, w1, c41);
            v = _mm256_broadcast_ss(a5 + i);
            c50 = _mm256_fmadd_ps(v, w0, c50);
            c51 = _mm256_fmadd_ps(v, w1, c51);
        }
        _mm256_storeu_ps(c, c00), _mm256_storeu_ps(c + 8, c01), _mm256_storeu_ps(c + 16, c10);
        _mm256_storeu_ps(c + 24, c11), _mm256_storeu_ps(c + 32, c20), _mm256_storeu_ps(c + 40, c21);
        _mm256_storeu_ps(c + 48, c30), _mm256_storeu_ps(c + 56, c31), _mm256_storeu_ps(c + 64, c40);
        _mm256_storeu_ps(c + 72, c41), _mm256_storeu_ps(c + 80, c50), _mm256_storeu_ps(c + 88, c51);
    }
}

GSF__INLINE_AVX2 void gsf__conv_add_squares(__m256d v, __m256d* sum, __m256d* square) {
    *sum = _mm256_add_pd(*sum, v);
    *square = _mm256_fmadd_pd(v, v, *square);
}

// Eight outputs of `count` pixels.
GSF__INLINE_AVX2 void gsf__conv_store8(const float* c, int64_t count, int accumulate, float* out, int64_t ldo,
                                       double* sums) {
    __m256d s0 = _mm256_loadu_pd(sums), s1 = _mm256_loadu_pd(sums + 4), q0 = _mm256_loadu_pd(sums + GSF__CONV_N),
            q1 = _mm256_loadu_pd(sums + GSF__CONV_N + 4);
    for (int64_t m = 0; m < count; m++, c += GSF__CONV_N, out += ldo) {
        __m256 v = _mm256_loadu_ps(c);
        if (accumulate) v = _mm256_add_ps(_mm256_loadu_ps(out), v);
        _mm256_storeu_ps(out, v);
        gsf__conv_add_squares(_mm256_cvtps_pd(_mm256_castps256_ps128(v)), &s0, &q0);
        gsf__conv_add_squares(_mm256_cvtps_pd(_mm256_extractf128_ps(v, 1)), &s1, &q1);
    }
    _mm256_storeu_pd(sums, s0), _mm256_storeu_pd(sums + 4, s1);
    _mm256_storeu_pd(sums + GSF__CONV_N, q0), _mm256_storeu_pd(sums + GSF__CONV_N + 4, q1);
}

GSF__TARGET_AVX2 static void gsf__conv_store_avx2(const float* c, int64_t count, int64_t n, int accumulate, float* out,
                                                  int64_t ldo, double* sums) {
    int64_t i = 0;
    for (; i + 8 <= n; i += 8) gsf__conv_store8(c + i, count, accumulate, out + i, ldo, sums + i);
    if (i < n) gsf__conv_store_ref(c + i, count, n - i, accumulate, out + i, ldo, sums + i);
}

// e^x for x in [-87, 88], clamped to it; relative error below 2e-7. NaN stays.
GSF__INLINE_AVX2 __m256 gsf__conv_exp8(__m256 x) {
    x = _mm256_min_ps(_mm256_set1_ps(88.0f), _mm256_max_ps(_mm256_set1_ps(-87.0f), x)); // a NaN is the second operand
    const __m256 k = _mm256_round_ps(_mm256_mul_ps(x, _mm256_set1_ps(1.44269504f)),
                                     _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    __m256 r = _mm256_fnmadd_ps(k, _mm256_set1_ps(0.693359375f), x); // ln 2 in two parts, the first exact
    r = _mm256_fnmadd_ps(k, _mm256_set1_ps(-2.12194440e-4f), r);
    __m256 p = _mm256_set1_ps(1.0f / 5040.0f);
    p = _mm256_fmadd_ps(p, r, _mm256_set1_ps(1.0f / 720.0f));
    p = _mm256_fmadd_ps(p, r, _mm256_set1_ps(1.0f / 120.0f));
    p = _mm256_fmadd_ps(p, r, _mm256_set1_ps(1.0f / 24.0f));
    p = _mm256_fmadd_ps(p, r, _mm256_set1_ps(1.0f / 6.0f));
    p = _mm256_fmadd_ps(p, r, _mm256_set1_ps(0.5f));
    p = _mm256_add_ps(_mm256_fmadd_ps(_mm256_mul_ps(p, r), r, r), _mm256_set1_ps(1.0f));
    const __m256i scale = _mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(k), _mm256_set1_epi32(127)), 23);
    return _mm256_mul_ps(p, _mm256_castsi256_ps(scale));
}

GSF__TARGET_AVX2 static void gsf__conv_norm_silu_avx2(const float* x, int64_t count, const float* mean, const float* scale,
                                                      const float* offset, float* y) {
    const __m256 zero = _mm256_setzero_ps(), one = _mm256_set1_ps(1.0f);
    int64_t i = 0;
    for (; i + 8 <= count; i += 8) {
        const __m256 d = _mm256_sub_ps(_mm256_loadu_ps(x + i), _mm256_loadu_ps(mean + i));
        const __m256 v = _mm256_fmadd_ps(d, _mm256_loadu_ps(scale + i), _mm256_loadu_ps(offset + i));
        const __m256 e = gsf__conv_exp8(_mm256_sub_ps(zero, v));
        _mm256_storeu_ps(y + i, _mm256_div_ps(v, _mm256_add_ps(one, e)));
    }
    gsf__conv_norm_silu_ref(x + i, count - i, mean + i, scale + i, offset + i, y + i);
}
#endif

static const gsf__conv_kernels* gsf__conv_kernels_of(gsf_cpu_level level) {
    static const gsf__conv_kernels scalar = {gsf__conv_multiply_ref, gsf__conv_store_ref, gsf__conv_norm_silu_ref};
#if GSF__X86
    static const gsf__conv_kernels avx2 = {gsf__conv_multiply_avx2, gsf__conv_store_avx2, gsf__conv_norm_silu_avx2};
    if (level >= GSF_CPU_AVX2) return &avx2;
#endif
    (void)level;
    return &scalar;
}

static int64_t gsf__conv_min(int64_t a, int64_t b) { return a < b ? a : b; }

typedef struct gsf__conv_layer { // weight: (out, in, kt, kernel, kernel), or without kt
    const gsf_tensor *weight, *bias;
    int64_t in, out, kt, kernel;
} gsf__conv_layer;

static int64_t gsf__conv_taps(const gsf__conv_layer* layer) { return layer->kt * layer->kernel * layer->kernel; }
static int64_t gsf__conv_blocks(const gsf__conv_layer* layer) { return (layer->out + GSF__CONV_N - 1) / GSF__CONV_N; }
// Values per 16 outputs: their bias, then their weights.
static int64_t gsf__conv_panel(const gsf__conv_layer* layer) {
    return GSF__CONV_N * (1 + gsf__conv_taps(layer) * layer->in);
}
static int64_t gsf__conv_packed(const gsf__conv_layer* layer) {
    return gsf__conv_blocks(layer) * gsf__conv_panel(layer);
}

typedef struct gsf__conv_pack_job {
    const gsf__conv_layer* layer;
    float* out; // (blocks, panel)
} gsf__conv_pack_job;

// Sixteen outputs: (out, in, taps) to (taps, in, 16), absent outputs zero. A few input channels at a time, so that both
// sides stay in the first level cache.
static void gsf__conv_pack_block(void* arg, size_t block, int worker) {
    enum { CHANNELS = 16 };
    const gsf__conv_pack_job* job = (const gsf__conv_pack_job*)arg;
    const gsf__conv_layer* layer = job->layer;
    const int64_t taps = gsf__conv_taps(layer), first = (int64_t)block * GSF__CONV_N;
    const int64_t n_end = gsf__conv_min(layer->out - first, GSF__CONV_N);
    float* panel = job->out + (int64_t)block * gsf__conv_panel(layer);
    float* weights = panel + GSF__CONV_N;
    float values[CHANNELS * GSF__CONV_TAPS];
    (void)worker;
    if (n_end < GSF__CONV_N || !layer->bias) memset(panel, 0, (size_t)gsf__conv_panel(layer) * sizeof(float));
    if (layer->bias) gsf_nn_read_tensor(layer->bias, first, n_end, panel);
    for (int64_t c0 = 0; c0 < layer->in; c0 += CHANNELS) {
        const int64_t channels = gsf__conv_min(layer->in - c0, CHANNELS);
        for (int64_t n = 0; n < n_end; n++) {
            gsf_nn_read_tensor(layer->weight, ((first + n) * layer->in + c0) * taps, channels * taps, values);
            for (int64_t t = 0; t < taps; t++)
                for (int64_t c = 0; c < channels; c++)
                    weights[(t * layer->in + c0 + c) * GSF__CONV_N + n] = values[c * taps + t];
        }
    }
}

static void gsf__conv_pack(gsf_context* ctx, const gsf__conv_layer* layer, float* out) {
    gsf__conv_pack_job job = {layer, out};
    gsf__parallel_for(ctx, (size_t)gsf__conv_blocks(layer), gsf__conv_pack_block, &job);
}

// A 3 x 3 convolution of a frame doubled by nearest resize is four 2 x 2 convolutions of the frame itself, one for each
// parity (py, px) of the output pixel: kernel rows that fall on the same input row are added. The two rows take the
// kernel's rows {0} and {1, 2} at parity 0, {0, 1} and {2} at parity 1. 4/9 of the products.
static gsf__conv_layer gsf__conv_quarter(const gsf__conv_layer* layer) { // what one parity computes
    gsf__conv_layer quarter = *layer;
    quarter.kernel = 2;
    return quarter;
}

static void gsf__conv_pack_quarter(void* arg, size_t chunk, int worker) { // chunk: parity and 16 outputs
    const gsf__conv_pack_job* job = (const gsf__conv_pack_job*)arg;
    const gsf__conv_layer* layer = job->layer;
    const gsf__conv_layer quarter = gsf__conv_quarter(layer);
    const int64_t blocks = gsf__conv_blocks(layer), parity = (int64_t)chunk / blocks, in = layer->in;
    const int64_t first = (int64_t)chunk % blocks * GSF__CONV_N, n_end = gsf__conv_min(layer->out - first, GSF__CONV_N);
    float* panel = job->out + (int64_t)chunk * gsf__conv_panel(&quarter);
    (void)worker;
    memset(panel, 0, (size_t)gsf__conv_panel(&quarter) * sizeof(float));
    if (layer->bias) gsf_nn_read_tensor(layer->bias, first, n_end, panel);
    for (int64_t c = 0; c < in; c++)
        for (int64_t n = 0; n < n_end; n++) {
            float values[9];
            gsf_nn_read_tensor(layer->weight, ((first + n) * in + c) * 9, 9, values);
            for (int64_t y = 0; y < 3; y++)
                for (int64_t x = 0; x < 3; x++) {
                    const int64_t row = y > parity / 2, column = x > parity % 2;
                    panel[GSF__CONV_N * (1 + (row * 2 + column) * in + c) + n] += values[y * 3 + x];
                }
        }
}

// (parities, blocks, panel of a quarter)
static void gsf__conv_pack_quarters(gsf_context* ctx, const gsf__conv_layer* layer, float* out) {
    gsf__conv_pack_job job = {layer, out};
    gsf__parallel_for(ctx, (size_t)gsf__conv_blocks(layer) * 4, gsf__conv_pack_quarter, &job);
}

typedef struct gsf__conv_job { // one frame of output
    const gsf__conv_kernels* kernels;
    const float* in[3];              // kt input frames, oldest first
    int64_t in_height, in_stride;    // rows and floats per row of an input frame
    int64_t origin, step;            // floats from a row's start to what output column 0 reads; from column to column
    int64_t kt, kh, k;               // kernel rows kt x kh of k values
    int64_t stride, pad;             // of rows
    const float* packed;
    int64_t panel;
    int64_t height, width, outputs;
    float* out;                      // pixels ldo apart, rows out_row
    int64_t ldo, out_row;
    int accumulate;
    int64_t groups;                  // of outputs
    double* partial;                 // (segments, groups, 2): sums and sums of squares, or NULL
} gsf__conv_job;

static int64_t gsf__conv_columns(const gsf__conv_job* job) {
    return (job->width + GSF__CONV_COLUMNS - 1) / GSF__CONV_COLUMNS;
}
static int64_t gsf__conv_segments(const gsf__conv_job* job) {
    return (job->height + GSF__CONV_ROWS - 1) / GSF__CONV_ROWS * gsf__conv_columns(job);
}

// tile (rows, 30, 16) += all kernel rows of 16 outputs.
static void gsf__conv_sum(const gsf__conv_job* job, int64_t y0, int64_t rows, int64_t x0, int64_t columns, const float* b,
                          float* tile) {
    for (int64_t kt = 0; kt < job->kt; kt++)
        for (int64_t kh = 0; kh < job->kh; kh++)
            for (int64_t k0 = 0; k0 < job->k; k0 += GSF__CONV_K) {
                const int64_t k = gsf__conv_min(job->k - k0, GSF__CONV_K);
                for (int64_t r = 0; r < rows; r++) {
                    const int64_t y = (y0 + r) * job->stride + kh - job->pad;
                    if (y < 0 || y >= job->in_height) continue;
                    const float* a = job->in[kt] + y * job->in_stride + job->origin + x0 * job->step + k0;
                    job->kernels->multiply(a, job->step, columns, b, k, tile + r * GSF__CONV_COLUMNS * GSF__CONV_N);
                }
                b += k * GSF__CONV_N;
            }
}

static void gsf__conv_segment(void* arg, size_t segment, int worker) {
    const gsf__conv_job* job = (const gsf__conv_job*)arg;
    const int64_t across = gsf__conv_columns(job);
    const int64_t y0 = (int64_t)segment / across * GSF__CONV_ROWS, x0 = (int64_t)segment % across * GSF__CONV_COLUMNS;
    const int64_t rows = gsf__conv_min(job->height - y0, GSF__CONV_ROWS);
    const int64_t columns = gsf__conv_min(job->width - x0, GSF__CONV_COLUMNS);
    double* partial = job->partial ? job->partial + (int64_t)segment * job->groups * 2 : NULL;
    float tile[GSF__CONV_ROWS * GSF__CONV_COLUMNS * GSF__CONV_N];
    (void)worker;
    if (partial) memset(partial, 0, (size_t)job->groups * 2 * sizeof(double));
    for (int64_t n0 = 0; n0 < job->outputs; n0 += GSF__CONV_N) {
        const int64_t n = gsf__conv_min(job->outputs - n0, GSF__CONV_N);
        const float* b = job->packed + n0 / GSF__CONV_N * job->panel;
        double sums[2 * GSF__CONV_N];
        memset(sums, 0, sizeof sums);
        for (int64_t i = 0; i < rows * GSF__CONV_COLUMNS; i++)
            memcpy(tile + i * GSF__CONV_N, b, GSF__CONV_N * sizeof(float));
        gsf__conv_sum(job, y0, rows, x0, columns, b + GSF__CONV_N, tile);
        for (int64_t r = 0; r < rows; r++)
            job->kernels->store(tile + r * GSF__CONV_COLUMNS * GSF__CONV_N, columns, n, job->accumulate,
                                job->out + (y0 + r) * job->out_row + x0 * job->ldo + n0, job->ldo, sums);
        for (int64_t i = 0; partial && i < n; i++) {
            const int64_t group = (n0 + i) / (job->outputs / job->groups);
            partial[2 * group] += sums[i];
            partial[2 * group + 1] += sums[GSF__CONV_N + i];
        }
    }
}

// One frame; its sums (groups, 2), where asked for through job->partial, are written to `sums`.
static void gsf__conv_frame(gsf_context* ctx, gsf__conv_job* job, double* sums) {
    const int64_t segments = gsf__conv_segments(job);
    gsf__parallel_for(ctx, (size_t)segments, gsf__conv_segment, job);
    if (!job->partial) return;
    memset(sums, 0, (size_t)job->groups * 2 * sizeof(double));
    for (int64_t s = 0; s < segments; s++)
        for (int64_t i = 0; i < job->groups * 2; i++) sums[i] += job->partial[s * job->groups * 2 + i];
}

typedef struct gsf__conv_fill { // one frame, made ready to be convolved
    const gsf__conv_kernels* kernels;
    const float *x, *x2;             // (height, width, channels); x2: averaged with x, or NULL
    int64_t height, width, channels;
    const float *mean, *table;       // mean NULL: values as they are. table: scale and offset of each pixel of a coarser
    int64_t table_width;             //   frame (.., table_width, 2, channels), or of all pixels where that is 0
    int32_t shift;                   // log2 of pixels per pixel of the table
    float* out;                      // (height, width + 2, channels)
} gsf__conv_fill;

enum { GSF__CONV_FILL_ROWS = 4 };

static void gsf__conv_fill_row(const gsf__conv_fill* job, int64_t y) {
    const int64_t c = job->channels, w = job->width;
    const size_t pixel = (size_t)c * sizeof(float);
    float* out = job->out + y * (w + 2) * c;
    memset(out, 0, pixel);
    memset(out + (w + 1) * c, 0, pixel);
    out += c;
    if (job->mean) {
        for (int64_t x = 0; x < w; x++) {
            const int64_t at = job->table_width ? (y >> job->shift) * job->table_width + (x >> job->shift) : 0;
            const float* scale = job->table + at * 2 * c;
            job->kernels->norm_silu(job->x + (y * w + x) * c, c, job->mean, scale, scale + c, out + x * c);
        }
    } else if (job->x2) {
        const float *a = job->x + y * w * c, *b = job->x2 + y * w * c;
        for (int64_t i = 0; i < w * c; i++) out[i] = (a[i] + b[i]) * 0.5f;
    } else {
        memcpy(out, job->x + y * w * c, (size_t)w * pixel);
    }
}

static void gsf__conv_fill_rows(void* arg, size_t chunk, int worker) {
    const gsf__conv_fill* job = (const gsf__conv_fill*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * GSF__CONV_FILL_ROWS;
    for (int64_t y = begin; y < begin + GSF__CONV_FILL_ROWS && y < job->height; y++) gsf__conv_fill_row(job, y);
}

static void gsf__conv_fill_frame(gsf_context* ctx, gsf__conv_fill* job) {
    gsf__parallel_for(ctx, (size_t)((job->height + GSF__CONV_FILL_ROWS - 1) / GSF__CONV_FILL_ROWS), gsf__conv_fill_rows,
                      job);
}

static int64_t gsf__conv_frame_size(int64_t height, int64_t width, int64_t channels) { // floats, with the border
    return height * (width + 2) * channels;
}

// The part of a job that frames of one size share: input with a border at either side, `in_height` x `in_width`.
static gsf__conv_job gsf__conv_begin(gsf_context* ctx, const gsf__conv_layer* layer, int64_t in_height, int64_t in_width,
                                     int halve, const float* packed) {
    gsf__conv_job job;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__conv_kernels_of(ctx->cpu_level);
    job.in_height = in_height;
    job.in_stride = (in_width + 2) * layer->in;
    job.stride = halve ? 2 : 1;
    job.step = job.stride * layer->in;
    job.pad = halve ? 0 : layer->kernel / 2;
    job.origin = (1 - job.pad) * layer->in;
    job.kt = layer->kt;
    job.kh = layer->kernel;
    job.k = layer->kernel * layer->in;
    job.packed = packed;
    job.panel = gsf__conv_panel(layer);
    job.height = halve ? in_height / 2 : in_height;
    job.width = halve ? in_width / 2 : in_width;
    job.outputs = job.ldo = layer->out;
    job.out_row = job.width * job.ldo;
    job.groups = 1;
    return job;
}

static gsf_result gsf__check_conv(gsf_context* ctx, const gsf_nn_conv_desc* desc, gsf__conv_layer* layer) {
    const gsf_tensor* w = desc->weight;
    memset(layer, 0, sizeof *layer);
    if (!desc->x || !desc->y || !w || desc->frames < 1 || desc->height < 1 || desc->width < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convolution: x, y, weight or a size is missing");
    if (w->dtype != GSF_NN_F32 && w->dtype != GSF_NN_BF16 && w->dtype != GSF_NN_F16)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "convolution: %s is %s", w->name, gsf_nn_dtype_name(w->dtype));
    const int64_t kernel = w->rank == 4 || w->rank == 5 ? w->shape[w->rank - 1] : 0, kt = w->rank == 5 ? w->shape[2] : 1;
    if ((kernel != 1 && kernel != 3) || w->shape[w->rank - 2] != kernel || (kt != 1 && kt != 3) || w->count < 1)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "convolution: %s is no kernel of 1 or 3 x 1 or 3 x 3", w->name);
    if (desc->halve && (kernel != 3 || kt != 1 || desc->height < 2 || desc->width < 2))
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "convolution: %s cannot halve %lld x %lld", w->name,
                        (long long)desc->width, (long long)desc->height);
    if (desc->bias && desc->bias->count != w->shape[0])
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convolution: %s has %lld values, not %lld", desc->bias->name,
                        (long long)desc->bias->count, (long long)w->shape[0]);
    layer->weight = w;
    layer->bias = desc->bias;
    layer->out = w->shape[0];
    layer->in = w->shape[1];
    layer->kt = kt;
    layer->kernel = kernel;
    if (((double)desc->frames + 3.0) * (double)desc->height * ((double)desc->width + 2.0) *
            (double)(layer->in > layer->out ? layer->in : layer->out) > 1e15)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convolution: %lld frames of %lld x %lld are too large",
                        (long long)desc->frames, (long long)desc->width, (long long)desc->height);
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_convolve(gsf_context* ctx, gsf_nn_workspace* workspace, const gsf_nn_conv_desc* desc) {
    gsf__conv_layer layer;
    gsf_nn_workspace own;
    memset(&own, 0, sizeof own);
    GSF__TRY(gsf__check_conv(ctx, desc, &layer));
    const size_t plane = (size_t)desc->height * (size_t)desc->width * (size_t)layer.in;
    const size_t frame = (size_t)gsf__conv_frame_size(desc->height, desc->width, layer.in);
    float* memory = (float*)gsf__nn_scratch(ctx, workspace ? workspace : &own,
                                            ((size_t)gsf__conv_packed(&layer) + 3 * frame) * sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    float* packed = memory + 3 * frame;
    gsf__conv_pack(ctx, &layer, packed);
    gsf__conv_job job = gsf__conv_begin(ctx, &layer, desc->height, desc->width, desc->halve, packed);
    gsf__conv_fill fill;
    memset(&fill, 0, sizeof fill);
    fill.kernels = job.kernels;
    fill.height = desc->height;
    fill.width = desc->width;
    fill.channels = layer.in;
    job.accumulate = desc->accumulate;
    for (int64_t t = layer.kt == 3 && desc->before ? -2 : 0; t < desc->frames; t++) {
        fill.x = t < 0 ? desc->before + (size_t)(t + 2) * plane : desc->x + (size_t)t * plane;
        fill.out = memory + (size_t)((t + 3) % 3) * frame;
        gsf__conv_fill_frame(ctx, &fill);
        if (t < 0) continue;
        for (int64_t i = 0; i < layer.kt; i++) { // frames before the first one repeat it
            const int64_t source = t - layer.kt + 1 + i;
            job.in[i] = memory + (size_t)(source < 0 && !desc->before ? 0 : (source + 3) % 3) * frame;
        }
        job.out = desc->y + t * job.height * job.width * layer.out;
        gsf__conv_frame(ctx, &job, NULL);
    }
    gsf_nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn positions -------------------------------------------------------------

// ---- >>nn scheduler -------------------------------------------------------------

// ---- >>nn transformer -----------------------------------------------------------

// ---- >>nn vae -------------------------------------------------------------------

// A run keeps few large arrays (gsf__vae_run), each grown to the largest need: three activations (a block's input, the
// middle of its resnet, and the result of a widening shortcut), one bordered frame, the widened weights of one layer. Norm
// and SiLU are applied while a frame is given its border, so that normalised activations exist for three frames only, two
// of which are the cache that the next chunk needs anyway. Sums for a group norm are taken while its input is written.
// The same walk with `dry` set takes no memory and computes nothing, but counts both.

enum { GSF__VAE_ENCODER_FRAMES = 8, GSF__VAE_DECODER_FRAMES = 2 }; // frames of a chunk
enum { GSF__VAE_SLOTS = 4, GSF__VAE_INPUT = 3 };                   // activations; the last one is the chunk's input

typedef struct gsf__vae_norm { // a group norm; spatial.out > 0: its result times y(z) plus b(z), z the latents
    const gsf_tensor *weight, *bias;
    gsf__conv_layer y, b;
    double eps;
} gsf__vae_norm;

typedef struct gsf__vae_resnet { // x + conv2(silu(norm2(conv1(silu(norm1(x))))))
    gsf__vae_norm norm1, norm2;
    gsf__conv_layer conv1, conv2, shortcut; // shortcut.out 0: x itself
} gsf__vae_resnet;

typedef struct gsf__vae_block {
    gsf__vae_resnet* resnets;
    int32_t count;
    gsf__conv_layer sampler; // out 0: none. The encoder's halves, the decoder's doubles
    int time;                // frames, too
} gsf__vae_block;

typedef struct gsf__vae_net { // encoder or decoder
    int decoder;
    int64_t groups;
    gsf__conv_layer conv_in, conv_out;
    gsf__vae_norm norm_out;
    gsf__vae_block blocks[GSF_NN_VAE_LEVELS + 1];
    int32_t block_count, causal_count; // causal_count: layers that keep frames for the next chunk
} gsf__vae_net;

typedef struct gsf__vae_nets {
    gsf__vae_net encoder, decoder;
} gsf__vae_nets;

// ---- opening a model

typedef struct gsf__vae_loader {
    gsf_context* ctx;
    const gsf_nn_vae* vae;
    gsf__nn_loader tensors;
    gsf__vae_net* net;
} gsf__vae_loader;

static gsf_result gsf__vae_load_conv(gsf__vae_loader* l, const char* name, int64_t in, int64_t out, int64_t kt,
                                     int64_t kernel, gsf__conv_layer* layer) {
    int64_t shape[5];
    int32_t rank = 0;
    shape[rank++] = out;
    shape[rank++] = in;
    if (kt) shape[rank++] = kt; // 0: a 2D layer
    shape[rank++] = kernel;
    shape[rank++] = kernel;
    GSF__TRY(gsf__nn_need(&l->tensors, &layer->weight, rank, shape, "%s.weight", name));
    GSF__TRY(gsf__nn_need(&l->tensors, &layer->bias, 1, shape, "%s.bias", name));
    layer->in = in;
    layer->out = out;
    layer->kt = kt ? kt : 1;
    layer->kernel = kernel;
    l->net->causal_count += kt == 3;
    return GSF_OK;
}

static gsf_result gsf__vae_load_norm(gsf__vae_loader* l, const char* name, int64_t channels, double eps,
                                     gsf__vae_norm* norm) {
    char full[160];
    const char* layer = l->net->decoder ? ".norm_layer" : "";
    GSF__TRY(gsf__nn_need(&l->tensors, &norm->weight, 1, &channels, "%s%s.weight", name, layer));
    GSF__TRY(gsf__nn_need(&l->tensors, &norm->bias, 1, &channels, "%s%s.bias", name, layer));
    norm->eps = l->net->decoder ? 1e-6 : eps; // the spatial norm ignores the config's
    if (!l->net->decoder) return GSF_OK;
    snprintf(full, sizeof full, "%s.conv_y.conv", name);
    GSF__TRY(gsf__vae_load_conv(l, full, l->vae->latent_channels, channels, 1, 1, &norm->y));
    snprintf(full, sizeof full, "%s.conv_b.conv", name);
    return gsf__vae_load_conv(l, full, l->vae->latent_channels, channels, 1, 1, &norm->b);
}

static gsf_result gsf__vae_load_resnet(gsf__vae_loader* l, const char* name, int64_t in, int64_t out,
                                       gsf__vae_resnet* resnet) {
    char full[128];
    snprintf(full, sizeof full, "%s.norm1", name);
    GSF__TRY(gsf__vae_load_norm(l, full, in, l->vae->norm_eps, &resnet->norm1));
    snprintf(full, sizeof full, "%s.conv1.conv", name);
    GSF__TRY(gsf__vae_load_conv(l, full, in, out, 3, 3, &resnet->conv1));
    snprintf(full, sizeof full, "%s.norm2", name);
    GSF__TRY(gsf__vae_load_norm(l, full, out, l->vae->norm_eps, &resnet->norm2));
    snprintf(full, sizeof full, "%s.conv2.conv", name);
    GSF__TRY(gsf__vae_load_conv(l, full, out, out, 3, 3, &resnet->conv2));
    if (in == out) return GSF_OK;
    snprintf(full, sizeof full, "%s.conv_shortcut", name);
    return gsf__vae_load_conv(l, full, in, out, 1, 1, &resnet->shortcut);
}

// `count` resnets, the first of which changes the channels.
static gsf_result gsf__vae_load_block(gsf__vae_loader* l, const char* name, int64_t in, int64_t out, int32_t count) {
    char full[96];
    gsf__vae_block* block = &l->net->blocks[l->net->block_count++];
    block->resnets = (gsf__vae_resnet*)gsf_alloc_zeroed(l->ctx, (size_t)count, sizeof *block->resnets);
    if (!block->resnets) return GSF_ERROR_OUT_OF_MEMORY;
    block->count = count;
    for (int32_t i = 0; i < count; i++) {
        snprintf(full, sizeof full, "%s.resnets.%d", name, (int)i);
        GSF__TRY(gsf__vae_load_resnet(l, full, i ? out : in, out, &block->resnets[i]));
    }
    return GSF_OK;
}

static gsf_result gsf__vae_load_net(gsf__vae_loader* l, int decoder) {
    const gsf_nn_vae* vae = l->vae;
    const char* side = decoder ? "decoder" : "encoder";
    const int32_t last = vae->levels - 1;
    const int64_t coarse = vae->channels[last];
    char name[64];
    l->net->decoder = decoder;
    l->net->groups = vae->norm_groups;
    snprintf(name, sizeof name, "%s.conv_in.conv", side);
    GSF__TRY(gsf__vae_load_conv(l, name, decoder ? vae->latent_channels : vae->in_channels,
                                decoder ? coarse : vae->channels[0], 3, 3, &l->net->conv_in));
    snprintf(name, sizeof name, "%s.mid_block", side);
    if (decoder) GSF__TRY(gsf__vae_load_block(l, name, coarse, coarse, 2));
    int64_t in = decoder ? coarse : vae->channels[0];
    for (int32_t i = 0; i < vae->levels; i++) {
        const int64_t out = vae->channels[decoder ? last - i : i];
        snprintf(name, sizeof name, "%s.%s_blocks.%d", side, decoder ? "up" : "down", (int)i);
        GSF__TRY(gsf__vae_load_block(l, name, in, out, vae->layers_per_block + decoder));
        in = out;
        if (i == last) break;
        gsf__vae_block* block = &l->net->blocks[l->net->block_count - 1];
        block->time = 2 << i <= vae->temporal_ratio;
        snprintf(name, sizeof name, "%s.%s_blocks.%d.%ssamplers.0.conv", side, decoder ? "up" : "down", (int)i,
                 decoder ? "up" : "down");
        GSF__TRY(gsf__vae_load_conv(l, name, out, out, 0, 3, &block->sampler));
    }
    snprintf(name, sizeof name, "%s.mid_block", side);
    if (!decoder) GSF__TRY(gsf__vae_load_block(l, name, coarse, coarse, 2));
    snprintf(name, sizeof name, "%s.norm_out", side);
    GSF__TRY(gsf__vae_load_norm(l, name, in, 1e-6, &l->net->norm_out));
    snprintf(name, sizeof name, "%s.conv_out.conv", side);
    return gsf__vae_load_conv(l, name, in, decoder ? vae->out_channels : 2 * vae->latent_channels, 3, 3,
                              &l->net->conv_out);
}

static gsf_result gsf__vae_check_types(const gsf__nn_config* config, const char* key, const char* type, size_t levels) {
    const gsf_json_value* list = gsf_json_member(&config->json, &config->json.values[0], key);
    if (!list || list->type == GSF_JSON_NULL) return GSF_OK;
    int ok = list->type == GSF_JSON_ARRAY && list->count == levels;
    for (uint32_t i = ok ? list->child : 0; i; i = config->json.values[i].next)
        ok = ok && config->json.values[i].type == GSF_JSON_STRING && strcmp(config->json.values[i].string, type) == 0;
    if (ok) return GSF_OK;
    return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s:%u: %s is not %zu times %s", config->json.name,
                    (unsigned)list->offset, key, levels, type);
}

static gsf_result gsf__vae_config_int(const gsf__nn_config* config, const char* key, int64_t fallback, int64_t high,
                                      int32_t* out) {
    int64_t value;
    GSF__TRY(gsf__nn_config_int_or(config, key, fallback, 1, high, &value));
    *out = (int32_t)value;
    return GSF_OK;
}

static gsf_result gsf__vae_check_unsupported(const gsf__nn_config* config) {
    const char *act, *classname;
    int quant, post_quant;
    GSF__TRY(gsf__nn_config_string(config, "_class_name", "AutoencoderKLCogVideoX", &classname));
    GSF__TRY(gsf__nn_config_string(config, "act_fn", "silu", &act));
    GSF__TRY(gsf__nn_config_bool_or(config, "use_quant_conv", 0, &quant));
    GSF__TRY(gsf__nn_config_bool_or(config, "use_post_quant_conv", 0, &post_quant));
    if (strcmp(classname, "AutoencoderKLCogVideoX") != 0)
        return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: model is %.60s, not AutoencoderKLCogVideoX",
                        config->json.name, classname);
    if (strcmp(act, "silu") != 0)
        return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: act_fn is %.60s, not silu", config->json.name, act);
    if (quant || post_quant)
        return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: quant_conv and post_quant_conv are not served",
                        config->json.name);
    return GSF_OK;
}

// Fallbacks are the class's own.
static gsf_result gsf__vae_take_config(const gsf__nn_config* config, gsf_nn_vae* vae) {
    int64_t channels[GSF_NN_VAE_LEVELS];
    size_t levels;
    GSF__TRY(gsf__vae_check_unsupported(config));
    GSF__TRY(gsf__vae_config_int(config, "in_channels", 3, 64, &vae->in_channels));
    GSF__TRY(gsf__vae_config_int(config, "out_channels", 3, 64, &vae->out_channels));
    GSF__TRY(gsf__vae_config_int(config, "latent_channels", 16, 1024, &vae->latent_channels));
    GSF__TRY(gsf__vae_config_int(config, "layers_per_block", 3, 64, &vae->layers_per_block));
    GSF__TRY(gsf__vae_config_int(config, "norm_num_groups", 32, 8192, &vae->norm_groups));
    GSF__TRY(gsf__vae_config_int(config, "temporal_compression_ratio", 4, 128, &vae->temporal_ratio));
    GSF__TRY(gsf__vae_config_int(config, "sample_height", 480, 1 << 20, &vae->sample_height));
    GSF__TRY(gsf__vae_config_int(config, "sample_width", 720, 1 << 20, &vae->sample_width));
    GSF__TRY(gsf__nn_config_number_or(config, "norm_eps", 1e-6, 0.0, 1.0, &vae->norm_eps));
    GSF__TRY(gsf__nn_config_number_or(config, "scaling_factor", 1.15258426, 1e-6, 1e6, &vae->scaling_factor));
    GSF__TRY(gsf__nn_config_ints(config, "block_out_channels", 1, 8192, GSF_NN_VAE_LEVELS, channels, &levels));
    GSF__TRY(gsf__vae_check_types(config, "down_block_types", "CogVideoXDownBlock3D", levels));
    GSF__TRY(gsf__vae_check_types(config, "up_block_types", "CogVideoXUpBlock3D", levels));
    vae->levels = (int32_t)levels;
    vae->spatial_ratio = 1 << (levels - 1);
    int32_t temporal = 1; // the nearest power of two from below, and no more than there are samplers
    while (2 * temporal <= vae->temporal_ratio && 2 * temporal <= vae->spatial_ratio) temporal *= 2;
    vae->temporal_ratio = temporal;
    for (size_t i = 0; i < levels; i++) {
        vae->channels[i] = (int32_t)channels[i];
        if (channels[i] % vae->norm_groups != 0)
            return gsf_fail(config->ctx, GSF_ERROR_FORMAT, "%s: %lld channels are no multiple of norm_num_groups %d",
                            config->json.name, (long long)channels[i], (int)vae->norm_groups);
    }
    return GSF_OK;
}

static gsf_result gsf__vae_read_config(gsf_context* ctx, const char* folder, gsf_nn_vae* vae) {
    gsf_text path;
    gsf__nn_config config;
    memset(&path, 0, sizeof path);
    gsf_text_printf(ctx, &path, "%s/config.json", folder);
    gsf_result result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf__nn_load_config(ctx, path.data, &config);
    gsf_destroy_text(ctx, &path);
    if (result != GSF_OK) return result;
    result = gsf__vae_take_config(&config, vae);
    gsf__nn_close_config(&config);
    return result;
}

static gsf_result gsf__vae_load_nets(gsf_context* ctx, gsf_nn_vae* vae) {
    gsf__vae_loader l;
    memset(&l, 0, sizeof l);
    gsf__vae_nets* nets = (gsf__vae_nets*)gsf_alloc_zeroed(ctx, 1, sizeof *nets);
    if (!nets) return GSF_ERROR_OUT_OF_MEMORY;
    vae->nets = nets;
    l.ctx = ctx;
    l.vae = vae;
    GSF__TRY(gsf__nn_begin_loading(ctx, &vae->weights, &l.tensors));
    l.net = &nets->encoder;
    gsf_result result = gsf__vae_load_net(&l, 0);
    l.net = &nets->decoder;
    if (result == GSF_OK) result = gsf__vae_load_net(&l, 1);
    return gsf__nn_end_loading(&l.tensors, result);
}

GSF_API gsf_result gsf_nn_make_vae(gsf_context* ctx, const char* folder, gsf_nn_vae* out) {
    memset(out, 0, sizeof *out);
    gsf_result result = gsf__vae_read_config(ctx, folder, out);
    if (result == GSF_OK) result = gsf_nn_open_weights(ctx, folder, "diffusion_pytorch_model", &out->weights);
    if (result == GSF_OK) result = gsf__vae_load_nets(ctx, out);
    if (result != GSF_OK) gsf_nn_destroy_vae(ctx, out);
    return result;
}

static void gsf__vae_free_net(gsf_context* ctx, gsf__vae_net* net) {
    for (int32_t i = 0; i < net->block_count; i++) gsf_free(ctx, net->blocks[i].resnets);
}

GSF_API void gsf_nn_destroy_vae(gsf_context* ctx, gsf_nn_vae* vae) {
    gsf__vae_nets* nets = (gsf__vae_nets*)vae->nets;
    if (nets) {
        gsf__vae_free_net(ctx, &nets->encoder);
        gsf__vae_free_net(ctx, &nets->decoder);
        gsf_free(ctx, nets);
    }
    gsf_nn_close_weights(ctx, &vae->weights);
    memset(vae, 0, sizeof *vae);
}

// ---- one run

typedef struct gsf__vae_buffer {
    float* data;
    size_t size; // bytes
} gsf__vae_buffer;

typedef struct gsf__vae_cache { // of one causal layer: its last two input frames, normalised and bordered
    gsf__vae_buffer frames[2];
    int last[2]; // which of them comes last but one, and last; -1: none yet
} gsf__vae_cache;

typedef struct gsf__vae_map { // an activation (frames, height, width, channels)
    int slot;
    int64_t frames, height, width, channels;
} gsf__vae_map;

// For tests: a layer's result (frame -1, in slot layout), or a frame of what a norm and SiLU made (with its border).
// `weight` names the layer.
typedef struct gsf__vae_watch {
    void (*fn)(void* user, const gsf_tensor* weight, int64_t chunk, const gsf__vae_map* map, int64_t frame,
               const float* data);
    void* user;
} gsf__vae_watch;

typedef struct gsf__vae_run {
    gsf_context* ctx;
    const gsf__vae_net* net;
    int dry;
    double flops;
    size_t bytes, peak;
    gsf__vae_buffer slots[GSF__VAE_SLOTS], spare, packed, table, partial, sums;
    gsf__vae_cache* caches;  // per causal layer; a clip of one chunk uses only the first, for all
    int32_t cache_at;
    gsf__vae_map z;          // the chunk's latents (decoder)
    int64_t chunk, chunks, done, total; // done, total: chunks of all tiles
    const char* stage;
    gsf__vae_watch watch;
} gsf__vae_run;

static gsf_result gsf__vae_grow(gsf__vae_run* run, gsf__vae_buffer* buffer, int64_t count) {
    const size_t size = (size_t)count * sizeof(float); // gsf__vae_plan has bounded it
    if (size <= buffer->size) return GSF_OK;
    run->bytes += size - buffer->size;
    if (run->bytes > run->peak) run->peak = run->bytes;
    if (!run->dry) {
        gsf_free(run->ctx, buffer->data);
        buffer->size = 0;
        buffer->data = (float*)gsf_alloc(run->ctx, size, 1);
        if (!buffer->data) return GSF_ERROR_OUT_OF_MEMORY;
    }
    buffer->size = size;
    return GSF_OK;
}

static void gsf__vae_release(gsf_context* ctx, gsf__vae_buffer* buffer) {
    gsf_free(ctx, buffer->data);
    memset(buffer, 0, sizeof *buffer);
}

static void gsf__vae_end(gsf__vae_run* run) {
    for (int i = 0; i < GSF__VAE_SLOTS; i++) gsf__vae_release(run->ctx, &run->slots[i]);
    for (int32_t i = 0; run->caches && i < run->net->causal_count; i++) {
        gsf__vae_release(run->ctx, &run->caches[i].frames[0]);
        gsf__vae_release(run->ctx, &run->caches[i].frames[1]);
    }
    gsf_free(run->ctx, run->caches);
    gsf__vae_release(run->ctx, &run->spare);
    gsf__vae_release(run->ctx, &run->packed);
    gsf__vae_release(run->ctx, &run->table);
    gsf__vae_release(run->ctx, &run->partial);
    gsf__vae_release(run->ctx, &run->sums);
}

static gsf_result gsf__vae_begin(gsf__vae_run* run) { // sums: (slots, one frame and its part; groups, 2) doubles
    run->caches = (gsf__vae_cache*)gsf_alloc_zeroed(run->ctx, (size_t)run->net->causal_count, sizeof *run->caches);
    if (!run->caches) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf__vae_grow(run, &run->sums, (GSF__VAE_SLOTS + 2) * run->net->groups * 2 * 2);
}

static int64_t gsf__vae_plane(const gsf__vae_map* map) { return map->height * map->width * map->channels; }
static double* gsf__vae_sums(const gsf__vae_run* run, int slot) { // slot GSF__VAE_SLOTS: of one frame, + 1: a part of it
    return (double*)(void*)run->sums.data + slot * run->net->groups * 2;
}
static int64_t gsf__vae_groups(const gsf__vae_run* run, int64_t channels) {
    return channels % run->net->groups == 0 ? run->net->groups : 1;
}
static int gsf__vae_free_slot(int a, int b) { // the first that is neither
    int slot = 0;
    while (slot == a || slot == b) slot++;
    return slot;
}

// `tensor`: the weight of the layer whose result is at fault; its name loses ".conv.weight".
static gsf_result gsf__vae_fail_nan(const gsf__vae_run* run, const gsf_tensor* tensor) {
    char name[160];
    snprintf(name, sizeof name, "%s", tensor->name);
    char* end = strstr(name, ".weight");
    if (end) *end = 0;
    end = strstr(name, ".conv");
    while (end && strcmp(end, ".conv") != 0) end = strstr(end + 1, ".conv");
    if (end) *end = 0;
    return gsf_fail(run->ctx, GSF_ERROR_NUMERIC, "%s: NaN or infinity in the result of %s, chunk %lld of %lld", run->stage,
                    name, (long long)run->chunk + 1, (long long)run->chunks);
}

typedef struct gsf__vae_blend { // table (pixels, 2, channels): y and b become factors and summands of the normalised input
    float* table;
    const float *scale, *shift; // of the group norm: inverse deviation * weight, and bias
    int64_t width, channels;
} gsf__vae_blend;

static void gsf__vae_blend_row(void* arg, size_t row, int worker) {
    const gsf__vae_blend* job = (const gsf__vae_blend*)arg;
    (void)worker;
    for (int64_t x = 0; x < job->width; x++) {
        float* y = job->table + ((int64_t)row * job->width + x) * 2 * job->channels;
        float* b = y + job->channels;
        for (int64_t c = 0; c < job->channels; c++) {
            b[c] += y[c] * job->shift[c];
            y[c] *= job->scale[c];
        }
    }
}

// conv_y and conv_b over the latents, at their own resolution: pointwise, so the nearest resize may follow.
static void gsf__vae_spatial(gsf__vae_run* run, const gsf__vae_norm* norm, const float* scale, const float* shift,
                             float* table) {
    const int64_t c = norm->y.out;
    const gsf__conv_layer* const layers[2] = {&norm->y, &norm->b};
    gsf__vae_blend blend = {table, scale, shift, run->z.width, c};
    for (int i = 0; i < 2; i++) {
        gsf__conv_pack(run->ctx, layers[i], run->packed.data);
        gsf__conv_job job = gsf__conv_begin(run->ctx, layers[i], run->z.frames * run->z.height, run->z.width, 0,
                                            run->packed.data);
        job.in[0] = run->slots[GSF__VAE_INPUT].data;
        job.in_stride = run->z.width * run->z.channels; // no border
        job.origin = 0;
        job.out = table + i * c;
        job.ldo = 2 * c;
        job.out_row = run->z.width * job.ldo;
        gsf__conv_frame(run->ctx, &job, NULL);
    }
    gsf__parallel_for(run->ctx, (size_t)(run->z.frames * run->z.height), gsf__vae_blend_row, &blend);
}

// run->table becomes (mean, scale, shift) per channel, and for the decoder the table of factors and summands after them.
static gsf_result gsf__vae_prepare_norm(gsf__vae_run* run, const gsf__vae_norm* norm, const gsf__vae_map* in) {
    const int64_t c = in->channels, groups = run->net->groups, per = c / groups;
    const int64_t pixels = norm->y.out ? run->z.frames * run->z.height * run->z.width : 0;
    GSF__TRY(gsf__vae_grow(run, &run->table, c * 3 + pixels * 2 * c));
    if (norm->y.out) {
        GSF__TRY(gsf__vae_grow(run, &run->packed, gsf__conv_packed(&norm->y)));
        run->flops += 4.0 * (double)(pixels * c * run->z.channels);
    }
    if (run->dry) return GSF_OK;
    float *mean = run->table.data, *scale = mean + c, *shift = scale + c;
    const double* sums = gsf__vae_sums(run, in->slot);
    const double count = (double)in->frames * (double)in->height * (double)in->width * (double)per;
    gsf_nn_read_tensor(norm->weight, 0, c, scale);
    gsf_nn_read_tensor(norm->bias, 0, c, shift);
    for (int64_t i = 0; i < c; i++) { // E[x^2] - E[x]^2 in double, of floats: good to 1e-8 at a mean of 1e4 deviations
        const double m = sums[i / per * 2] / count, v = sums[i / per * 2 + 1] / count - m * m;
        mean[i] = (float)m;
        scale[i] = (float)((double)scale[i] / sqrt((v > 0.0 ? v : 0.0) + norm->eps));
    }
    if (norm->y.out) gsf__vae_spatial(run, norm, scale, shift, shift + c);
    return GSF_OK;
}

// The latent frame that frame t of n sees: nearest, the first frame apart where n is odd.
static int64_t gsf__vae_latent_frame(int64_t t, int64_t n, int64_t latents) {
    if (n % 2 == 0 || n == 1) return t * latents / n;
    return t == 0 ? 0 : 1 + (t - 1) * (latents - 1) / (n - 1);
}

// Frame `t` of `in`, normalised where there is a norm, into `out` with a border.
static void gsf__vae_fill(gsf__vae_run* run, const gsf__vae_norm* norm, const gsf__vae_map* in, int64_t t, float* out) {
    gsf__conv_fill fill;
    memset(&fill, 0, sizeof fill);
    fill.kernels = gsf__conv_kernels_of(run->ctx->cpu_level);
    fill.x = run->slots[in->slot].data + t * gsf__vae_plane(in);
    fill.height = in->height;
    fill.width = in->width;
    fill.channels = in->channels;
    fill.out = out;
    if (norm) {
        fill.mean = run->table.data;
        fill.table = fill.mean + in->channels; // scale, shift
        if (norm->y.out) {
            const int64_t z = gsf__vae_latent_frame(t, in->frames, run->z.frames);
            fill.table_width = run->z.width;
            fill.table += 2 * in->channels + z * run->z.height * run->z.width * 2 * in->channels;
            while (run->z.height << fill.shift < in->height) fill.shift++;
        }
    }
    gsf__conv_fill_frame(run->ctx, &fill);
    if (norm && run->watch.fn) run->watch.fn(run->watch.user, norm->weight, run->chunk, in, t, out);
}

// Room for a layer's result in slot out->slot, its weights and its sums; starts the job. The weights are not packed yet.
static gsf_result gsf__vae_start(gsf__vae_run* run, const gsf__conv_layer* layer, const gsf__vae_map* in, int halve,
                                 gsf__vae_map* out, gsf__conv_job* job) {
    GSF__TRY(gsf__check_cancel(run->ctx));
    GSF__TRY(gsf__vae_grow(run, &run->packed, gsf__conv_packed(layer)));
    GSF__TRY(gsf__vae_grow(run, &run->slots[out->slot], out->frames * gsf__vae_plane(out)));
    *job = gsf__conv_begin(run->ctx, layer, in->height, in->width, halve, run->packed.data);
    job->groups = gsf__vae_groups(run, layer->out);
    GSF__TRY(gsf__vae_grow(run, &run->partial, gsf__conv_segments(job) * job->groups * 2 * 2));
    job->partial = (double*)(void*)run->partial.data;
    if (!run->dry) memset(gsf__vae_sums(run, out->slot), 0, (size_t)run->net->groups * 2 * sizeof(double));
    return GSF_OK;
}

static void gsf__vae_count(gsf__vae_run* run, const gsf__conv_layer* layer, const gsf__vae_map* out, int64_t frames) {
    run->flops += 2.0 * (double)(frames * out->height * out->width) *
                  (double)(gsf__conv_taps(layer) * layer->in * layer->out);
}

static void gsf__vae_add_sums(gsf__vae_run* run, int slot) {
    double* total = gsf__vae_sums(run, slot);
    const double* frame = gsf__vae_sums(run, GSF__VAE_SLOTS);
    for (int64_t i = 0; i < run->net->groups * 2; i++) total[i] += frame[i];
}

static gsf_result gsf__vae_finish(gsf__vae_run* run, const gsf__conv_layer* layer, const gsf__vae_map* out) {
    if (run->dry) return GSF_OK;
    const double* sums = gsf__vae_sums(run, out->slot);
    for (int64_t i = 0; i < gsf__vae_groups(run, layer->out) * 2; i++)
        if (!(fabs(sums[i]) <= DBL_MAX)) return gsf__vae_fail_nan(run, layer->weight);
    if (run->watch.fn)
        run->watch.fn(run->watch.user, layer->weight, run->chunk, out, -1, run->slots[out->slot].data);
    return GSF_OK;
}

// The frames that the next chunk's layer starts from; one that stands in the spare frame moves.
static void gsf__vae_keep(gsf__vae_run* run, gsf__vae_cache* cache, int before, int last, size_t bytes) {
    if (before == 2 || last == 2) {
        const int other = before == 2 ? last : before;
        const int room = other == 0;
        memcpy(cache->frames[room].data, run->spare.data, bytes);
        if (before == 2) before = room;
        if (last == 2) last = room;
    }
    cache->last[0] = before;
    cache->last[1] = last;
}

// A causal layer, `norm` and SiLU before it (NULL: neither); the result goes to out->slot, or is added to it.
static gsf_result gsf__vae_causal(gsf__vae_run* run, const gsf__conv_layer* layer, const gsf__vae_norm* norm,
                                  const gsf__vae_map* in, int accumulate, gsf__vae_map* out) {
    gsf__conv_job job;
    const int slot = out->slot;
    *out = *in;
    out->slot = slot;
    out->channels = layer->out;
    const int64_t frame = gsf__conv_frame_size(in->height, in->width, in->channels);
    gsf__vae_cache* cache = &run->caches[run->chunks == 1 ? 0 : run->cache_at++];
    if (run->chunk == 0) cache->last[0] = cache->last[1] = -1;
    GSF__TRY(gsf__vae_grow(run, &cache->frames[0], frame));
    GSF__TRY(gsf__vae_grow(run, &cache->frames[1], frame));
    GSF__TRY(gsf__vae_grow(run, &run->spare, frame));
    if (norm) GSF__TRY(gsf__vae_prepare_norm(run, norm, in));
    GSF__TRY(gsf__vae_start(run, layer, in, 0, out, &job));
    gsf__vae_count(run, layer, out, out->frames);
    if (run->dry) return GSF_OK;
    gsf__conv_pack(run->ctx, layer, run->packed.data);
    float* const ring[3] = {cache->frames[0].data, cache->frames[1].data, run->spare.data};
    int before = cache->last[0], last = cache->last[1];
    job.accumulate = accumulate;
    for (int64_t t = 0; t < in->frames; t++) {
        GSF__TRY(gsf__check_cancel(run->ctx));
        int now = 0;
        while (now == before || now == last) now++;
        gsf__vae_fill(run, norm, in, t, ring[now]);
        if (last < 0) before = last = now; // before the first frame: itself
        job.in[0] = ring[before];
        job.in[1] = ring[last];
        job.in[2] = ring[now];
        job.out = run->slots[slot].data + t * gsf__vae_plane(out);
        gsf__conv_frame(run->ctx, &job, gsf__vae_sums(run, GSF__VAE_SLOTS));
        gsf__vae_add_sums(run, slot);
        before = last;
        last = now;
    }
    if (run->chunk + 1 < run->chunks) gsf__vae_keep(run, cache, before, last, (size_t)frame * sizeof(float));
    return gsf__vae_finish(run, layer, out);
}

// Pointwise: to slot `slot`, or, where that is the input's and the channels get fewer, in place, frame by frame.
static gsf_result gsf__vae_shortcut(gsf__vae_run* run, const gsf__conv_layer* layer, const gsf__vae_map* in,
                                    gsf__vae_map* out) {
    gsf__conv_job job;
    const int slot = out->slot;
    *out = *in;
    out->slot = slot;
    out->channels = layer->out;
    const int64_t plane = gsf__vae_plane(out);
    GSF__TRY(gsf__vae_grow(run, &run->spare, plane));
    GSF__TRY(gsf__vae_start(run, layer, in, 0, out, &job));
    gsf__vae_count(run, layer, out, out->frames);
    if (run->dry) return GSF_OK;
    gsf__conv_pack(run->ctx, layer, run->packed.data);
    job.in_stride = in->width * in->channels;
    job.origin = 0;
    job.partial = NULL; // conv2 will be added
    for (int64_t t = 0; t < in->frames; t++) {
        float* y = run->slots[slot].data + t * plane;
        job.in[0] = run->slots[in->slot].data + t * gsf__vae_plane(in);
        job.out = slot == in->slot ? run->spare.data : y;
        gsf__conv_frame(run->ctx, &job, NULL);
        if (slot == in->slot) memcpy(y, run->spare.data, (size_t)plane * sizeof(float));
    }
    return GSF_OK;
}

static gsf_result gsf__vae_resnet_run(gsf__vae_run* run, const gsf__vae_resnet* resnet, gsf__vae_map* x) {
    gsf__vae_map middle, sum = *x;
    middle.slot = gsf__vae_free_slot(x->slot, -1);
    GSF__TRY(gsf__vae_causal(run, &resnet->conv1, &resnet->norm1, x, 0, &middle));
    if (resnet->shortcut.out) {
        if (resnet->shortcut.out > x->channels) sum.slot = gsf__vae_free_slot(x->slot, middle.slot);
        GSF__TRY(gsf__vae_shortcut(run, &resnet->shortcut, x, &sum));
    }
    GSF__TRY(gsf__vae_causal(run, &resnet->conv2, &resnet->norm2, &middle, 1, &sum));
    *x = sum;
    return GSF_OK;
}

// Source frame of frame t of a doubled clip; an odd clip's first frame is not doubled.
static int64_t gsf__vae_double_source(int64_t t, int64_t frames, int time) {
    return !time || frames == 1 ? t : frames % 2 ? (t + 1) / 2 : t / 2;
}

// One frame of gsf__vae_double: `job` for parity (0, 0) of a `width` wide input, packed weights of all four.
static void gsf__vae_double_frame(gsf__vae_run* run, const gsf__conv_layer* quarter, const gsf__conv_job* job, float* out) {
    double* sums = gsf__vae_sums(run, GSF__VAE_SLOTS);
    double* part = gsf__vae_sums(run, GSF__VAE_SLOTS + 1);
    memset(sums, 0, (size_t)run->net->groups * 2 * sizeof(double));
    for (int64_t parity = 0; parity < 4; parity++) {
        const int64_t py = parity / 2, px = parity % 2;
        gsf__conv_job one = *job;
        one.pad = 1 - py;
        one.origin = px * quarter->in;
        one.packed += parity * gsf__conv_packed(quarter);
        one.ldo = 2 * quarter->out;
        one.out_row = 2 * job->width * one.ldo;
        one.out = out + py * job->width * one.ldo + px * quarter->out;
        gsf__conv_frame(run->ctx, &one, part);
        for (int64_t i = 0; i < run->net->groups * 2; i++) sums[i] += part[i];
    }
}

// Nearest resize to twice the size and, with `time`, twice the frames, then a 2D convolution, once for frames that are
// alike.
static gsf_result gsf__vae_double(gsf__vae_run* run, const gsf__vae_block* block, gsf__vae_map* x) {
    const gsf__conv_layer quarter = gsf__conv_quarter(&block->sampler);
    gsf__conv_job job;
    gsf__vae_map out = *x;
    out.height *= 2;
    out.width *= 2;
    out.slot = gsf__vae_free_slot(x->slot, -1);
    if (block->time && x->frames > 1) out.frames = 2 * x->frames - x->frames % 2;
    const int64_t plane = gsf__vae_plane(&out);
    GSF__TRY(gsf__vae_grow(run, &run->spare, gsf__conv_frame_size(x->height, x->width, x->channels)));
    GSF__TRY(gsf__vae_grow(run, &run->packed, 4 * gsf__conv_packed(&quarter)));
    GSF__TRY(gsf__vae_start(run, &quarter, x, 0, &out, &job));
    gsf__vae_count(run, &quarter, &out, x->frames);
    if (!run->dry) gsf__conv_pack_quarters(run->ctx, &block->sampler, run->packed.data);
    job.in[0] = run->spare.data;
    for (int64_t t = 0; !run->dry && t < out.frames; t++) {
        const int64_t source = gsf__vae_double_source(t, x->frames, block->time);
        float* y = run->slots[out.slot].data + t * plane;
        if (t > 0 && source == gsf__vae_double_source(t - 1, x->frames, block->time)) {
            memcpy(y, y - plane, (size_t)plane * sizeof(float));
        } else {
            GSF__TRY(gsf__check_cancel(run->ctx));
            gsf__vae_fill(run, NULL, x, source, run->spare.data);
            gsf__vae_double_frame(run, &quarter, &job, y);
        }
        gsf__vae_add_sums(run, out.slot);
    }
    *x = out;
    return gsf__vae_finish(run, &block->sampler, x);
}

// With `time`, means of two frames (an odd clip's first frame stays alone), then a 2D convolution of stride 2.
static gsf_result gsf__vae_halve(gsf__vae_run* run, const gsf__vae_block* block, gsf__vae_map* x) {
    gsf__conv_job job;
    gsf__conv_fill fill;
    gsf__vae_map out = *x;
    const int64_t odd = x->frames % 2;
    out.slot = gsf__vae_free_slot(x->slot, -1);
    out.height /= 2;
    out.width /= 2;
    if (block->time) out.frames = (x->frames + 1) / 2;
    GSF__TRY(gsf__vae_grow(run, &run->spare, gsf__conv_frame_size(x->height, x->width, x->channels)));
    GSF__TRY(gsf__vae_start(run, &block->sampler, x, 1, &out, &job));
    gsf__vae_count(run, &block->sampler, &out, out.frames);
    if (!run->dry) gsf__conv_pack(run->ctx, &block->sampler, run->packed.data);
    memset(&fill, 0, sizeof fill);
    fill.height = x->height;
    fill.width = x->width;
    fill.channels = x->channels;
    fill.out = run->spare.data;
    job.in[0] = run->spare.data;
    for (int64_t t = 0; !run->dry && t < out.frames; t++) {
        const int64_t first = !block->time ? t : t == 0 ? 0 : 2 * t - odd;
        GSF__TRY(gsf__check_cancel(run->ctx));
        fill.x = run->slots[x->slot].data + first * gsf__vae_plane(x);
        fill.x2 = block->time && !(odd && t == 0) ? fill.x + gsf__vae_plane(x) : NULL;
        gsf__conv_fill_frame(run->ctx, &fill);
        job.out = run->slots[out.slot].data + t * gsf__vae_plane(&out);
        gsf__conv_frame(run->ctx, &job, gsf__vae_sums(run, GSF__VAE_SLOTS));
        gsf__vae_add_sums(run, out.slot);
    }
    *x = out;
    return gsf__vae_finish(run, &block->sampler, x);
}

// One chunk, whose input stands in slot GSF__VAE_INPUT.
static gsf_result gsf__vae_chunk(gsf__vae_run* run, const gsf__vae_map* in, gsf__vae_map* out) {
    const gsf__vae_net* net = run->net;
    gsf__vae_map x;
    run->z = *in;
    run->cache_at = 0;
    x.slot = 0;
    GSF__TRY(gsf__vae_causal(run, &net->conv_in, NULL, in, 0, &x));
    for (int32_t i = 0; i < net->block_count; i++) {
        const gsf__vae_block* block = &net->blocks[i];
        for (int32_t j = 0; j < block->count; j++) GSF__TRY(gsf__vae_resnet_run(run, &block->resnets[j], &x));
        if (!block->sampler.out) continue;
        if (net->decoder) GSF__TRY(gsf__vae_double(run, block, &x));
        else GSF__TRY(gsf__vae_halve(run, block, &x));
    }
    out->slot = gsf__vae_free_slot(x.slot, -1);
    return gsf__vae_causal(run, &net->conv_out, &net->norm_out, &x, 0, out);
}

// ---- clips

typedef struct gsf__vae_planes { // a view of (channels, frames, height, width) floats
    float* data;
    int64_t channels, frames, height, width;
    int64_t channel_stride, frame_stride, row_stride;
} gsf__vae_planes;

static gsf__vae_planes gsf__vae_wrap(float* data, int64_t channels, int64_t frames, int64_t height, int64_t width) {
    gsf__vae_planes p;
    p.data = data;
    p.channels = channels;
    p.frames = frames;
    p.height = height;
    p.width = width;
    p.channel_stride = frames * height * width;
    p.frame_stride = height * width;
    p.row_stride = width;
    return p;
}

static gsf__vae_planes gsf__vae_part(gsf__vae_planes p, int64_t y, int64_t x, int64_t height, int64_t width) {
    if (p.data) p.data += y * p.row_stride + x;
    p.height = p.height - y < height ? p.height - y : height;
    p.width = p.width - x < width ? p.width - x : width;
    return p;
}

static float* gsf__vae_row(const gsf__vae_planes* p, int64_t c, int64_t t, int64_t y) {
    return p->data + c * p->channel_stride + t * p->frame_stride + y * p->row_stride;
}

// Frames of a clip to channels-last.
static void gsf__vae_gather(const gsf__vae_planes* in, int64_t first, int64_t frames, float* out) {
    for (int64_t t = 0; t < frames; t++)
        for (int64_t y = 0; y < in->height; y++, out += in->width * in->channels)
            for (int64_t c = 0; c < in->channels; c++) {
                const float* row = gsf__vae_row(in, c, first + t, y);
                for (int64_t x = 0; x < in->width; x++) out[x * in->channels + c] = row[x];
            }
}

static void gsf__vae_scatter(const float* x, int64_t first, int64_t frames, const gsf__vae_planes* out) {
    for (int64_t t = 0; t < frames; t++)
        for (int64_t y = 0; y < out->height; y++, x += out->width * out->channels)
            for (int64_t c = 0; c < out->channels; c++) {
                float* row = gsf__vae_row(out, c, first + t, y);
                for (int64_t i = 0; i < out->width; i++) row[i] = x[i * out->channels + c];
            }
}

static int64_t gsf__vae_chunk_count(int64_t frames, int decoder) {
    const int64_t per = decoder ? GSF__VAE_DECODER_FRAMES : GSF__VAE_ENCODER_FRAMES;
    return frames < per ? 1 : frames / per;
}

// Frames of chunk k: the remainder joins the first.
static int64_t gsf__vae_chunk_frames(int64_t frames, int decoder, int64_t k) {
    const int64_t per = decoder ? GSF__VAE_DECODER_FRAMES : GSF__VAE_ENCODER_FRAMES;
    if (frames < per) return frames;
    return k == 0 ? per + frames % per : per;
}

static int64_t gsf__vae_out_frames(const gsf_nn_vae* vae, int64_t frames, int decoder) {
    int64_t sum = 0;
    const int64_t chunks = gsf__vae_chunk_count(frames, decoder);
    for (int64_t k = 0; k < 2 && k < chunks; k++) { // all but the first are alike
        int64_t n = gsf__vae_chunk_frames(frames, decoder, k);
        for (int32_t ratio = vae->temporal_ratio; ratio > 1; ratio /= 2) {
            if (!decoder) n = (n + 1) / 2;
            else if (n > 1) n = 2 * n - n % 2;
        }
        sum += k ? n * (chunks - 1) : n;
    }
    return sum;
}

// All chunks of a clip or tile.
static gsf_result gsf__vae_clip(gsf__vae_run* run, const gsf__vae_planes* in, const gsf__vae_planes* out) {
    int64_t first = 0, out_first = 0;
    run->chunks = gsf__vae_chunk_count(in->frames, run->net->decoder);
    for (run->chunk = 0; run->chunk < run->chunks; run->chunk++) {
        gsf__vae_map x, y;
        x.slot = GSF__VAE_INPUT;
        x.frames = gsf__vae_chunk_frames(in->frames, run->net->decoder, run->chunk);
        x.height = in->height;
        x.width = in->width;
        x.channels = in->channels;
        GSF__TRY(gsf__vae_grow(run, &run->slots[GSF__VAE_INPUT], x.frames * gsf__vae_plane(&x)));
        if (!run->dry) gsf__vae_gather(in, first, x.frames, run->slots[GSF__VAE_INPUT].data);
        GSF__TRY(gsf__vae_chunk(run, &x, &y));
        if (!run->dry) {
            gsf__vae_scatter(run->slots[y.slot].data, out_first, y.frames, out);
            gsf__progress(run->ctx, run->stage, (double)++run->done, (double)run->total);
        }
        first += x.frames;
        out_first += y.frames;
    }
    return GSF_OK;
}

typedef struct gsf__vae_plan { // how a job is tiled; an untiled one is a single tile
    int64_t out_frames, out_height, out_width, out_channels;
    int64_t rows, columns;                 // tiles
    int64_t tile[2], step[2];              // height, width of a tile of the input; distance of two
    int64_t out_step[2], blend[2];         // the same distance and the overlap in the result
} gsf__vae_plan;

// int() of a Python float.
static int64_t gsf__vae_whole(double value) { return (int64_t)floor(value); }

static gsf_result gsf__vae_plan_axis(gsf_context* ctx, const gsf_nn_vae* vae, int decoder, const char* axis, int64_t tile,
                                     double overlap, int i, gsf__vae_plan* plan) {
    const int64_t ratio = vae->spatial_ratio, latent = tile / ratio;
    const int64_t blend = gsf__vae_whole((double)tile * overlap), latent_blend = gsf__vae_whole((double)latent * overlap);
    const int64_t step = gsf__vae_whole((double)tile * (1.0 - overlap));
    const int64_t latent_step = gsf__vae_whole((double)latent * (1.0 - overlap));
    if (tile % ratio != 0 || blend != latent_blend * ratio || step != tile - blend ||
        latent_step != latent - latent_blend || latent_step < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "tiling: a tile %s of %lld times overlap %g is not a whole number of latents (%d pixels each)",
                        axis, (long long)tile, overlap, (int)ratio);
    plan->tile[i] = decoder ? latent : tile;
    plan->step[i] = decoder ? latent_step : step;
    plan->out_step[i] = decoder ? step : latent_step;
    plan->blend[i] = decoder ? blend : latent_blend;
    return GSF_OK;
}

static gsf_result gsf__vae_check_size(gsf_context* ctx, const gsf_nn_vae* vae, int decoder, int64_t frames, int64_t height,
                                      int64_t width) {
    double widest = 2.0 * vae->latent_channels;
    const int64_t least = decoder ? 1 : vae->spatial_ratio;
    if (!vae->nets) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "vae: no model is open");
    if (frames < 1 || height < least || width < least)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "vae: %lld frames of %lld x %lld, but at least 1 of %lld x %lld "
                        "is needed", (long long)frames, (long long)width, (long long)height, (long long)least,
                        (long long)least);
    for (int32_t i = 0; i < vae->levels; i++)
        if (vae->channels[i] > widest) widest = vae->channels[i];
    const double scale = decoder ? (double)vae->spatial_ratio * vae->spatial_ratio * vae->temporal_ratio : 1.0;
    if ((double)frames * ((double)height + 2.0) * ((double)width + 2.0) * scale * widest > 1e15) // sizes below 2^63
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "vae: %lld frames of %lld x %lld are too large", (long long)frames,
                        (long long)width, (long long)height);
    return GSF_OK;
}

static gsf_result gsf__vae_make_plan(gsf_context* ctx, const gsf_nn_vae* vae, int decoder, const gsf_nn_vae_desc* desc,
                                     int64_t frames, int64_t height, int64_t width, gsf__vae_plan* plan) {
    const int64_t ratio = vae->spatial_ratio;
    memset(plan, 0, sizeof *plan);
    GSF__TRY(gsf__vae_check_size(ctx, vae, decoder, frames, height, width));
    plan->out_channels = decoder ? vae->out_channels : 2 * vae->latent_channels;
    plan->out_frames = gsf__vae_out_frames(vae, frames, decoder);
    plan->out_height = decoder ? height * ratio : height / ratio;
    plan->out_width = decoder ? width * ratio : width / ratio;
    plan->rows = plan->columns = 1;
    plan->tile[0] = plan->step[0] = height;
    plan->tile[1] = plan->step[1] = width;
    plan->out_step[0] = plan->out_height;
    plan->out_step[1] = plan->out_width;
    if (!desc || !desc->tiled) return GSF_OK;
    gsf__vae_plan tiled = *plan;
    const int64_t tile_height = desc->tile_height ? desc->tile_height : vae->sample_height / 2;
    const int64_t tile_width = desc->tile_width ? desc->tile_width : vae->sample_width / 2;
    GSF__TRY(gsf__vae_plan_axis(ctx, vae, decoder, "height", tile_height,
                                desc->overlap_height > 0.0 ? desc->overlap_height : 1.0 / 6.0, 0, &tiled));
    GSF__TRY(gsf__vae_plan_axis(ctx, vae, decoder, "width", tile_width,
                                desc->overlap_width > 0.0 ? desc->overlap_width : 1.0 / 5.0, 1, &tiled));
    if (height <= tiled.tile[0] && width <= tiled.tile[1]) return GSF_OK;
    tiled.rows = (height + tiled.step[0] - 1) / tiled.step[0];
    tiled.columns = (width + tiled.step[1] - 1) / tiled.step[1];
    const int64_t bottom = height - (tiled.rows - 1) * tiled.step[0], right = width - (tiled.columns - 1) * tiled.step[1];
    if (!decoder && (bottom % ratio != 0 || right % ratio != 0))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "tiling: %lld x %lld leaves a last tile of %lld x %lld, which is no multiple of %lld",
                        (long long)width, (long long)height, (long long)right, (long long)bottom, (long long)ratio);
    *plan = tiled;
    return GSF_OK;
}

// b's first lines fade from a's last ones, in place. `across`: columns instead of rows.
static void gsf__vae_fade(const gsf__vae_planes* a, const gsf__vae_planes* b, int64_t extent, int across) {
    const int64_t a_size = across ? a->width : a->height, b_size = across ? b->width : b->height;
    if (extent > a_size) extent = a_size;
    if (extent > b_size) extent = b_size;
    for (int64_t i = 0; i < extent; i++) {
        const float weight = (float)((double)i / (double)extent), rest = (float)(1.0 - (double)i / (double)extent);
        const int64_t lines = across ? b->height : b->width;
        for (int64_t c = 0; c < b->channels; c++)
            for (int64_t t = 0; t < b->frames; t++)
                for (int64_t j = 0; j < lines; j++) {
                    float* y = across ? gsf__vae_row(b, c, t, j) + i : gsf__vae_row(b, c, t, i) + j;
                    const float x = across ? gsf__vae_row(a, c, t, j)[a_size - extent + i]
                                           : gsf__vae_row(a, c, t, a_size - extent + i)[j];
                    *y = x * rest + *y * weight;
                }
    }
}

static void gsf__vae_copy(const gsf__vae_planes* from, const gsf__vae_planes* to) { // what both have
    const int64_t height = from->height < to->height ? from->height : to->height;
    const int64_t width = from->width < to->width ? from->width : to->width;
    for (int64_t c = 0; c < to->channels; c++)
        for (int64_t t = 0; t < to->frames; t++)
            for (int64_t y = 0; y < height; y++)
                memcpy(gsf__vae_row(to, c, t, y), gsf__vae_row(from, c, t, y), (size_t)width * sizeof(float));
}

// Height (axis 0) or width of tile k of an input of `size`.
static int64_t gsf__vae_tile_size(const gsf__vae_plan* plan, int axis, int64_t size, int64_t k) {
    const int64_t left = size - k * plan->step[axis];
    return left < plan->tile[axis] ? left : plan->tile[axis];
}

// Tile after tile, each over all frames. A tile is blended with the blended ones above and to the left, which is why two
// rows of tiles are kept: tiles (2, columns).
static gsf_result gsf__vae_tiles(gsf__vae_run* run, const gsf__vae_plan* plan, const gsf__vae_planes* in,
                                 const gsf__vae_planes* out, gsf__vae_buffer* tiles) {
    const int64_t ratio_up = run->net->decoder ? plan->out_step[0] / plan->step[0] : 1;
    const int64_t ratio_down = run->net->decoder ? 1 : plan->step[0] / plan->out_step[0];
    for (int64_t i = 0; i < plan->rows; i++)
        for (int64_t j = 0; j < plan->columns; j++) {
            const gsf__vae_planes part = gsf__vae_part(*in, i * plan->step[0], j * plan->step[1], plan->tile[0],
                                                       plan->tile[1]);
            gsf__vae_buffer *own = &tiles[i % 2 * plan->columns + j], *above = &tiles[(i + 1) % 2 * plan->columns + j];
            const int64_t h = part.height * ratio_up / ratio_down, w = part.width * ratio_up / ratio_down;
            GSF__TRY(gsf__vae_grow(run, own, plan->out_channels * plan->out_frames * h * w));
            const gsf__vae_planes tile = gsf__vae_wrap(own->data, plan->out_channels, plan->out_frames, h, w);
            GSF__TRY(gsf__vae_clip(run, &part, &tile));
            if (run->dry) continue;
            if (i > 0) {
                const int64_t size = gsf__vae_tile_size(plan, 0, in->height, i - 1) * ratio_up / ratio_down;
                const gsf__vae_planes a = gsf__vae_wrap(above->data, plan->out_channels, plan->out_frames, size, w);
                gsf__vae_fade(&a, &tile, plan->blend[0], 0);
            }
            if (j > 0) {
                const int64_t size = gsf__vae_tile_size(plan, 1, in->width, j - 1) * ratio_up / ratio_down;
                const gsf__vae_planes a = gsf__vae_wrap(own[-1].data, plan->out_channels, plan->out_frames, h, size);
                gsf__vae_fade(&a, &tile, plan->blend[1], 1);
            }
            const gsf__vae_planes place = gsf__vae_part(*out, i * plan->out_step[0], j * plan->out_step[1],
                                                        plan->out_step[0], plan->out_step[1]);
            gsf__vae_copy(&tile, &place);
        }
    return GSF_OK;
}

typedef struct gsf__vae_task {
    const gsf_nn_vae* vae;
    gsf__vae_plan plan;
    int decoder;
    int64_t frames, height, width;
    gsf__vae_buffer moments; // encoder: (2 latent_channels, ...)
    gsf__vae_buffer* tiles;
    gsf__vae_watch watch;
} gsf__vae_task;

static gsf_result gsf__vae_walk(gsf__vae_run* run, gsf__vae_task* task, const float* in, float* out) {
    const gsf__vae_plan* plan = &task->plan;
    const gsf_nn_vae* vae = task->vae;
    GSF__TRY(gsf__vae_begin(run));
    if (!task->decoder) {
        GSF__TRY(gsf__vae_grow(run, &task->moments,
                               plan->out_channels * plan->out_frames * plan->out_height * plan->out_width));
        out = task->moments.data;
    }
    // The input is only read; gsf__vae_planes serves both ways.
    const gsf__vae_planes from =
        gsf__vae_wrap((float*)(uintptr_t)in, task->decoder ? vae->latent_channels : vae->in_channels, task->frames,
                      task->height, task->width);
    const gsf__vae_planes to = gsf__vae_wrap(out, plan->out_channels, plan->out_frames, plan->out_height, plan->out_width);
    if (plan->rows * plan->columns == 1) return gsf__vae_clip(run, &from, &to);
    task->tiles = (gsf__vae_buffer*)gsf_alloc_zeroed(run->ctx, (size_t)plan->columns * 2, sizeof *task->tiles);
    if (!task->tiles) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf__vae_tiles(run, plan, &from, &to, task->tiles);
}

// Runs, or with in == NULL only counts: *flops and *bytes.
static gsf_result gsf__vae_execute(gsf_context* ctx, gsf__vae_task* task, const float* in, float* out, float* mean,
                                   float* logvar, double* flops, double* bytes) {
    const gsf__vae_nets* nets = (const gsf__vae_nets*)task->vae->nets;
    gsf__vae_run run;
    memset(&run, 0, sizeof run);
    run.ctx = ctx;
    run.net = task->decoder ? &nets->decoder : &nets->encoder;
    run.dry = !in;
    run.total = gsf__vae_chunk_count(task->frames, task->decoder) * task->plan.rows * task->plan.columns;
    run.stage = task->decoder ? "vae decode" : "vae encode";
    run.watch = task->watch;
    const gsf_result result = gsf__vae_walk(&run, task, in, out);
    *flops = run.flops;
    *bytes = (double)run.peak;
    if (result == GSF_OK && in && !task->decoder) {
        const size_t half = task->moments.size / sizeof(float) / 2;
        const float* moments = task->moments.data;
        memcpy(mean, moments, half * sizeof(float));
        for (size_t i = 0; logvar && i < half; i++) {
            const float v = moments[half + i];
            logvar[i] = v < -30.0f ? -30.0f : v > 20.0f ? 20.0f : v;
        }
    }
    for (int64_t i = 0; task->tiles && i < task->plan.columns * 2; i++) gsf__vae_release(ctx, &task->tiles[i]);
    gsf_free(ctx, task->tiles);
    task->tiles = NULL;
    gsf__vae_release(ctx, &task->moments);
    gsf__vae_end(&run);
    return result;
}

static gsf_result gsf__vae_make_task(gsf_context* ctx, const gsf_nn_vae* vae, int decoder, const gsf_nn_vae_desc* desc,
                                     int64_t frames, int64_t height, int64_t width, gsf__vae_task* task,
                                     gsf_nn_vae_info* info) {
    memset(task, 0, sizeof *task);
    memset(info, 0, sizeof *info);
    task->vae = vae;
    task->decoder = decoder;
    task->frames = frames;
    task->height = height;
    task->width = width;
    GSF__TRY(gsf__vae_make_plan(ctx, vae, decoder, desc, frames, height, width, &task->plan));
    info->frames = task->plan.out_frames;
    info->height = task->plan.out_height;
    info->width = task->plan.out_width;
    info->chunks = gsf__vae_chunk_count(frames, decoder) * task->plan.rows * task->plan.columns;
    return gsf__vae_execute(ctx, task, NULL, NULL, NULL, NULL, &info->flops, &info->bytes);
}

GSF_API gsf_result gsf_nn_query_vae(gsf_context* ctx, const gsf_nn_vae* vae, gsf_nn_vae_way way,
                                    const gsf_nn_vae_desc* desc, int64_t frames, int64_t height, int64_t width,
                                    gsf_nn_vae_info* out) {
    gsf__vae_task task;
    return gsf__vae_make_task(ctx, vae, way == GSF_NN_VAE_DECODE, desc, frames, height, width, &task, out);
}

static gsf_result gsf__vae_check_finite(gsf_context* ctx, const char* what, const float* x, int64_t channels,
                                        int64_t frames, int64_t height, int64_t width) {
    const int64_t count = channels * frames * height * width;
    for (int64_t i = 0; i < count; i++)
        if (!(fabsf(x[i]) <= FLT_MAX))
            return gsf_fail(ctx, GSF_ERROR_NUMERIC,
                            "%s: NaN or infinity in channel %lld, frame %lld, row %lld, column %lld", what,
                            (long long)(i / (frames * height * width)), (long long)(i / (height * width) % frames),
                            (long long)(i / width % height), (long long)(i % width));
    return GSF_OK;
}

static gsf_result gsf__vae_apply(gsf_context* ctx, const gsf_nn_vae* vae, int decoder, const gsf_nn_vae_desc* desc,
                                 const float* in, int64_t frames, int64_t height, int64_t width, float* video, float* mean,
                                 float* logvar) {
    gsf__vae_task task;
    gsf_nn_vae_info info;
    const char* stage = decoder ? "vae decode" : "vae encode";
    double flops, bytes;
    if (!in || (decoder ? !video : !mean))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: an array is missing", stage);
    GSF__TRY(gsf__vae_make_task(ctx, vae, decoder, desc, frames, height, width, &task, &info));
    if (desc && desc->max_bytes > 0.0 && info.bytes > desc->max_bytes)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: needs %.0f MiB, %.0f are allowed", stage,
                        ceil(info.bytes / 1048576.0), desc->max_bytes / 1048576.0);
    GSF__TRY(gsf__vae_check_finite(ctx, decoder ? "latents" : "video", in,
                                   decoder ? vae->latent_channels : vae->in_channels, frames, height, width));
    const gsf_result result = gsf__vae_execute(ctx, &task, in, video, mean, logvar, &flops, &bytes);
    if (result == GSF_OK) return GSF_OK;
    const size_t plane = (size_t)(info.frames * info.height * info.width) * sizeof(float);
    if (video) memset(video, 0, plane * (size_t)vae->out_channels);
    if (mean) memset(mean, 0, plane * (size_t)vae->latent_channels);
    if (logvar) memset(logvar, 0, plane * (size_t)vae->latent_channels);
    return result;
}

GSF_API gsf_result gsf_nn_vae_encode(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                     const float* video, int64_t frames, int64_t height, int64_t width, float* mean,
                                     float* logvar) {
    return gsf__vae_apply(ctx, vae, 0, desc, video, frames, height, width, NULL, mean, logvar);
}

GSF_API gsf_result gsf_nn_vae_decode(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                     const float* latents, int64_t frames, int64_t height, int64_t width, float* video) {
    return gsf__vae_apply(ctx, vae, 1, desc, latents, frames, height, width, video, NULL, NULL);
}

// ---- >>nn sampling --------------------------------------------------------------

// ---- >>nn restorer --------------------------------------------------------------

GSF__END_IMPLEMENTATION

#endif // GSF_NN_IMPLEMENTED
#endif // GSFIXER_NN_IMPLEMENTATION
