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
// Every length, offset, shape and dtype is checked: malformed files give GSF_ERROR_FORMAT with file and byte offset. The
// tensors of a file must cover its data exactly. BOOL reads as U8; other dtypes are unsupported. With the default io hook
// files are mapped where the platform can: nobody may shorten them while they are open.
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

// ---- positions ------------------------------------------------------------------
// Tables of the video transformer. Tokens stand in the order frame, row, column.

typedef struct gsf_nn_rope_desc {
    int32_t frames, height, width;   // of the grid of tokens: latent frames, latent height and width / patch size
    int32_t base_height, base_width; // the grid the model was trained with: sample_height, sample_width / patch size
    int32_t head_dim;                // a multiple of 16: time has head_dim/4 of it, rows and columns 3*head_dim/8 each
    double theta;                    // 0: 10000
} gsf_nn_rope_desc;

// Rotary table: cos, sin (frames*height*width, head_dim), every value twice, for interleaved pairs. Pair i of an axis of
// d values turns by position * theta^(-2i/d). Positions: frames 0, 1, ...; rows linspace(top, bottom*(h-1)/h, h) where
// the grid, resized to fit into the base grid with its aspect ratio kept, lies from top to bottom in it; columns alike.
// Angles are float32 products in the order of the reference, so they match its tables, not the exact ones.
// (diffusers 0.32.1 embeddings.py get_3d_rotary_pos_embed, pipeline_cogvideox.py get_resize_crop_region_for_grid)
GSF_API GSF_NODISCARD gsf_result gsf_nn_make_rope(gsf_context* ctx, const gsf_nn_rope_desc* desc, float* cos, float* sin);

// Sine-cosine positions: out (frames*height*width, dim); dim, a multiple of 16, is time dim/4 | columns 3*dim/8 | rows
// 3*dim/8, each [sin | cos] of position/scale * 10000^(-i/(d/2)). Computed in double. scales: 0 = 1.
// (diffusers 0.32.1 embeddings.py get_3d_sincos_pos_embed)
GSF_API GSF_NODISCARD gsf_result gsf_nn_make_sincos(gsf_context* ctx, int32_t frames, int32_t height, int32_t width,
                                                    int32_t dim, double spatial_scale, double temporal_scale, float* out);

// Embedding of a diffusion time step (0..999): out (dim) = [cos | sin] of t * exp(-ln(10000) i / (dim/2)), an odd last
// value 0. Angles in float32 as the reference has them. (diffusers 0.32.1 get_timestep_embedding, flip_sin_to_cos)
GSF_API void gsf_nn_embed_timestep(double timestep, int32_t dim, float* out);

// ---- noise schedule and solvers -------------------------------------------------
// x_t = sqrt(abar_t) x0 + sqrt(1 - abar_t) noise. The model predicts v = sqrt(abar) noise - sqrt(1 - abar) x0, so that
// x0 = sqrt(abar) x - sqrt(1 - abar) v. Coefficients are double, latents float32.

typedef enum gsf_nn_alpha_table {
    GSF_NN_TABLE_DDIM = 0, // float32, in the order of diffusers' DDIMScheduler, which the official pipeline runs
    GSF_NN_TABLE_COGX,     // float64, diffusers' CogVideoXDDIMScheduler; differs by 5e-7
} gsf_nn_alpha_table;

typedef enum gsf_nn_spacing { GSF_NN_TRAILING = 0, GSF_NN_LEADING, GSF_NN_LINSPACE } gsf_nn_spacing;

typedef struct gsf_nn_schedule_desc { // all zero: CogVideoX-5B's
    int32_t train_steps;           // 0: 1000
    double beta_start, beta_end;   // 0: 0.00085, 0.012
    int linear_betas;              // else linear in sqrt(beta) ("scaled_linear")
    int no_zero_snr;               // else the table is stretched so that abar ends at 0
    int no_alpha_one;              // else the last step goes to abar = 1, not to abar of time step 0
    gsf_nn_spacing spacing;
    int32_t steps_offset;          // added to the time steps of GSF_NN_LEADING
    double snr_shift_scale;        // 0: 1; of GSF_NN_TABLE_COGX only, as DDIMScheduler knows no such thing
    gsf_nn_alpha_table table;
} gsf_nn_schedule_desc;

typedef struct gsf_nn_schedule {
    gsf_nn_schedule_desc desc; // with the defaults filled in
    double* alpha_bar;         // (train_steps), owned
    double final_alpha_bar;
} gsf_nn_schedule;

GSF_API GSF_NODISCARD gsf_result gsf_nn_make_schedule(gsf_context* ctx, const gsf_nn_schedule_desc* desc,
                                                      gsf_nn_schedule* out);
// From a scheduler_config.json; keys that are missing have the defaults of diffusers' DDIMScheduler. The class it names
// is not looked at, as the official pipeline does not either. What is not v-prediction or clips is unsupported.
GSF_API GSF_NODISCARD gsf_result gsf_nn_parse_schedule(gsf_context* ctx, const char* name, const char* text, size_t size,
                                                       gsf_nn_alpha_table table, gsf_nn_schedule* out);
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_schedule(gsf_context* ctx, const char* path, gsf_nn_alpha_table table,
                                                      gsf_nn_schedule* out);
GSF_API void gsf_nn_destroy_schedule(gsf_context* ctx, gsf_nn_schedule* schedule);

// Time steps for `steps` (1..train_steps) model calls, falling. strength in (0, 1] (0: 1) keeps the last
// (int)(steps * strength) of them, for latents that start as the noised render. out: room for `steps`.
GSF_API GSF_NODISCARD gsf_result gsf_nn_make_timesteps(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t steps,
                                                       double strength, int32_t* out, int32_t* count);

// Elementwise over `count` values; out may be an input. timestep: 0..train_steps-1.
GSF_API void gsf_nn_add_noise(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x0,
                              const float* noise, size_t count, float* out);
GSF_API void gsf_nn_make_velocity(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x0,
                                  const float* noise, size_t count, float* out);
GSF_API void gsf_nn_predict_x0(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x,
                               const float* v, size_t count, float* out);

typedef enum gsf_nn_solver {
    GSF_NN_DDIM = 0,   // first order; the next time is t - train_steps/steps (whole division), as diffusers has it
    GSF_NN_DPMPP_2M,   // DPM-Solver++(2M): second order, remembers one prediction (Lu et al. 2022b)
    GSF_NN_UNIPC,      // UniPC, B2, order 2: that and a corrector which needs no further model call (Zhao et al. 2023)
} gsf_nn_solver;

typedef struct gsf_nn_sampler_desc {
    gsf_nn_solver solver;
    int32_t steps;      // 0: 50
    double strength;    // 0: 1
    size_t value_count; // of the latents
} gsf_nn_sampler_desc;

// A run of a solver. `index` and `memory` are all that a checkpoint must keep beside the latents: make the sampler anew
// with the same desc and fill them in.
typedef struct gsf_nn_sampler {
    gsf_nn_sampler_desc desc;
    const gsf_nn_schedule* schedule; // borrowed
    int32_t* timesteps;              // (count)
    int32_t count, index;            // the next model call is for timesteps[index]
    float* memory;                   // (memory_count): earlier predictions
    size_t memory_count;             // 0, 1 or 3 times value_count
} gsf_nn_sampler;

GSF_API GSF_NODISCARD gsf_result gsf_nn_make_sampler(gsf_context* ctx, const gsf_nn_schedule* schedule,
                                                     const gsf_nn_sampler_desc* desc, gsf_nn_sampler* out);
GSF_API void gsf_nn_destroy_sampler(gsf_context* ctx, gsf_nn_sampler* sampler);
// One step: x (value_count), the latents at timesteps[index], becomes those at the next one; v is the model's output for
// x. x0 (NULL allowed) gets the predicted clean latents. eta is 0: nothing is random. A latent that is NaN or infinite
// afterwards gives GSF_ERROR_NUMERIC, which names the step.
GSF_API GSF_NODISCARD gsf_result gsf_nn_step_sampler(gsf_context* ctx, gsf_nn_sampler* sampler, const float* v, float* x,
                                                     float* x0);

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
        return gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%zu: %zu bytes belong to no tensor", h->name,
                        (size_t)(next - h->text), (size_t)(end - next));
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
    GSF__TRY(gsf__reserve(h->ctx, (void**)&weights->tensors, &files->tensor_capacity, first, first + root->count + 1,
                          sizeof *weights->tensors)); // + 1: there always is an array
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
    if (ok) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "tensor %s: name, dtype, shape, count and data do not fit",
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

// ---- >>nn positions -------------------------------------------------------------

// torch.linspace in float32: from both ends towards the middle, multiplied and added with one rounding.
static float gsf__nn_linspace(float start, float end, int32_t count, int32_t i) {
    if (count == 1) return start;
    const float step = (end - start) / (float)(count - 1);
    return i < count / 2 ? fmaf(step, (float)i, start) : fmaf(-step, (float)(count - 1 - i), end);
}

// Where a grid of height x width lies in the base grid when it is resized to fit: first[0], last[0] rows, [1] columns,
// last exclusive. Rounding is Python's, half to even, which rint is in the default rounding mode.
static void gsf__nn_fit_grid(const gsf_nn_rope_desc* desc, double first[2], double last[2]) {
    const double th = desc->base_height, tw = desc->base_width, h = desc->height, w = desc->width;
    const int tall = h / w > th / tw;
    const double rows = tall ? th : rint(tw / w * h), columns = tall ? rint(th / h * w) : tw;
    first[0] = rint((th - rows) / 2.0);
    first[1] = rint((tw - columns) / 2.0);
    last[0] = first[0] + rows;
    last[1] = first[1] + columns;
}

// cosine, sine (count, dim) of one axis at positions linspace(start, end).
static void gsf__nn_rope_axis(float start, float end, int32_t count, int32_t dim, double theta, float* cosine,
                              float* sine) {
    for (int32_t k = 0; k < dim; k += 2) {
        const float exponent = (float)k / (float)dim;
        const float frequency = 1.0f / (float)pow(theta, (double)exponent);
        for (int32_t i = 0; i < count; i++) {
            const float angle = gsf__nn_linspace(start, end, count, i) * frequency;
            const float c = (float)cos((double)angle), s = (float)sin((double)angle);
            const int64_t at = (int64_t)i * dim + k;
            cosine[at] = cosine[at + 1] = c;
            sine[at] = sine[at + 1] = s;
        }
    }
}

static gsf_result gsf__nn_check_grid(gsf_context* ctx, const char* what, int32_t frames, int32_t height, int32_t width,
                                     int32_t dim) {
    if (frames < 1 || height < 1 || width < 1 || (int64_t)frames * height > INT32_MAX / width)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: a grid of %d frames, %d x %d tokens", what, (int)frames,
                        (int)height, (int)width);
    if (dim < 16 || dim % 16 != 0)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: dimension %d is no multiple of 16", what, (int)dim);
    return GSF_OK;
}

// Joins the rows of three axis tables: out row (t, h, w) = [a row t | b row ... | c row ...], where b belongs to rows and
// c to columns of the grid, or the other way round.
typedef struct gsf__nn_axes {
    int32_t frames, height, width, dim;
    int columns_first;
} gsf__nn_axes;

static void gsf__nn_join_axes(const gsf__nn_axes* axes, size_t row, int32_t part, int64_t* at, int32_t* size) {
    const int64_t w = (int64_t)row % axes->width, h = (int64_t)row / axes->width % axes->height;
    const int64_t t = (int64_t)row / axes->width / axes->height;
    const int32_t time = axes->dim / 4, space = axes->dim / 8 * 3;
    *size = part == 0 ? time : space;
    *at = part == 0 ? t * time : ((part == 1) != axes->columns_first ? h : w) * space;
}

GSF_API gsf_result gsf_nn_make_rope(gsf_context* ctx, const gsf_nn_rope_desc* desc, float* cosine, float* sine) {
    GSF__TRY(gsf__nn_check_grid(ctx, "rope", desc->frames, desc->height, desc->width, desc->head_dim));
    if (desc->base_height < 1 || desc->base_width < 1 || !(desc->theta >= 0.0) || desc->theta > 1e30)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "rope: a base grid of %d x %d, theta %g", (int)desc->base_height,
                        (int)desc->base_width, desc->theta);
    const gsf__nn_axes axes = {desc->frames, desc->height, desc->width, desc->head_dim, 0};
    const int32_t counts[3] = {desc->frames, desc->height, desc->width};
    const double theta = desc->theta != 0.0 ? desc->theta : 10000.0;
    double first[3] = {0.0, 0.0, 0.0}, last[3] = {(double)desc->frames, 0.0, 0.0};
    float* table[3]; // of each axis the cosines, then the sines
    gsf__nn_fit_grid(desc, first + 1, last + 1);
    const size_t width = (size_t)desc->head_dim;
    float* block = (float*)gsf_alloc(ctx, (size_t)desc->frames + (size_t)desc->height + (size_t)desc->width,
                                     2 * width * sizeof(float));
    if (!block) return GSF_ERROR_OUT_OF_MEMORY;
    for (int axis = 0; axis < 3; axis++) {
        const int32_t n = counts[axis], dim = axis == 0 ? desc->head_dim / 4 : desc->head_dim / 8 * 3;
        table[axis] = axis == 0 ? block : table[axis - 1] + 2 * (size_t)counts[axis - 1] * width;
        gsf__nn_rope_axis((float)first[axis], (float)(last[axis] * (n - 1) / n), n, dim, theta, table[axis],
                          table[axis] + (size_t)n * width);
    }
    const size_t rows = (size_t)counts[0] * (size_t)counts[1] * (size_t)counts[2];
    for (size_t row = 0; row < rows; row++)
        for (int32_t part = 0; part < 3; part++) {
            int64_t at;
            int32_t size;
            gsf__nn_join_axes(&axes, row, part, &at, &size);
            memcpy(cosine, table[part] + at, (size_t)size * sizeof(float));
            memcpy(sine, table[part] + (size_t)counts[part] * width + at, (size_t)size * sizeof(float));
            cosine += size;
            sine += size;
        }
    gsf_free(ctx, block);
    return GSF_OK;
}

// (count, dim) of one axis: [sin | cos]. The positions are float32, as numpy's there.
static void gsf__nn_sincos_axis(int32_t count, int32_t dim, double scale, double* out) {
    const int32_t half = dim / 2;
    for (int32_t k = 0; k < half; k++) {
        const double frequency = 1.0 / pow(10000.0, (double)k / (dim / 2.0));
        for (int32_t i = 0; i < count; i++) {
            const double angle = (double)((float)i / (float)scale) * frequency;
            out[(int64_t)i * dim + k] = sin(angle);
            out[(int64_t)i * dim + half + k] = cos(angle);
        }
    }
}

// To `wide` or `narrow`, whichever is not NULL.
static gsf_result gsf__nn_sincos(gsf_context* ctx, const gsf__nn_axes* axes, double spatial_scale, double temporal_scale,
                                 double* wide, float* narrow) {
    GSF__TRY(gsf__nn_check_grid(ctx, "sincos", axes->frames, axes->height, axes->width, axes->dim));
    if (!(spatial_scale > 0.0) || !(temporal_scale > 0.0))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sincos: scales %g, %g", spatial_scale, temporal_scale);
    const size_t width = (size_t)axes->dim;
    double* time = (double*)gsf_alloc(ctx, (size_t)axes->frames + (size_t)axes->height + (size_t)axes->width,
                                      width * sizeof(double));
    if (!time) return GSF_ERROR_OUT_OF_MEMORY;
    double *columns = time + (size_t)axes->frames * width, *down = columns + (size_t)axes->width * width;
    const double* table[3] = {time, columns, down};
    gsf__nn_sincos_axis(axes->frames, axes->dim / 4, temporal_scale, time);
    gsf__nn_sincos_axis(axes->width, axes->dim / 8 * 3, spatial_scale, columns);
    gsf__nn_sincos_axis(axes->height, axes->dim / 8 * 3, spatial_scale, down);
    const size_t rows = (size_t)axes->frames * (size_t)axes->height * (size_t)axes->width;
    for (size_t row = 0, o = 0; row < rows; row++)
        for (int32_t part = 0; part < 3; part++) {
            int64_t at;
            int32_t size;
            gsf__nn_join_axes(axes, row, part, &at, &size);
            for (int32_t k = 0; k < size; k++, o++) {
                if (wide) wide[o] = table[part][at + k];
                if (narrow) narrow[o] = (float)table[part][at + k];
            }
        }
    gsf_free(ctx, time);
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_make_sincos(gsf_context* ctx, int32_t frames, int32_t height, int32_t width, int32_t dim,
                                      double spatial_scale, double temporal_scale, float* out) {
    const gsf__nn_axes axes = {frames, height, width, dim, 1};
    return gsf__nn_sincos(ctx, &axes, spatial_scale != 0.0 ? spatial_scale : 1.0,
                          temporal_scale != 0.0 ? temporal_scale : 1.0, NULL, out);
}

GSF_API void gsf_nn_embed_timestep(double timestep, int32_t dim, float* out) {
    const int32_t half = dim / 2;
    if (dim % 2 != 0) out[dim - 1] = 0.0f;
    for (int32_t i = 0; i < half; i++) {
        const float exponent = -9.210340371976184f * (float)i / (float)half; // -ln(10000) i / half
        const float angle = (float)timestep * (float)exp((double)exponent);
        out[i] = (float)cos((double)angle);
        out[half + i] = (float)sin((double)angle);
    }
}

// ---- >>nn scheduler -------------------------------------------------------------

// torch.linspace in double, which is float32's formula.
static double gsf__nn_linspace64(double start, double end, int32_t count, int32_t i) {
    const double step = (end - start) / (count - 1);
    return i < count / 2 ? start + step * i : end - step * (count - 1 - i);
}

// Beta as float32, and as float64.
static float gsf__nn_beta32(const gsf_nn_schedule_desc* d, int32_t i) {
    if (d->linear_betas) return gsf__nn_linspace((float)d->beta_start, (float)d->beta_end, d->train_steps, i);
    const float root = gsf__nn_linspace((float)sqrt(d->beta_start), (float)sqrt(d->beta_end), d->train_steps, i);
    return root * root;
}

static double gsf__nn_beta64(const gsf_nn_schedule_desc* d, int32_t i) {
    if (d->linear_betas) return gsf__nn_linspace64(d->beta_start, d->beta_end, d->train_steps, i);
    const double root = gsf__nn_linspace64(sqrt(d->beta_start), sqrt(d->beta_end), d->train_steps, i);
    return root * root;
}

// Every value is rounded to float32 where torch stores a tensor; cumprod alone accumulates in double, as torch does on a
// CPU. Zero SNR: Lin et al. 2024, algorithm 1: sqrt(abar) is shifted and scaled to end at 0, then turned back into betas.
// (diffusers 0.32.1 scheduling_ddim.py rescale_zero_terminal_snr and __init__)
static void gsf__nn_fill_ddim(const gsf_nn_schedule_desc* d, double* alpha_bar) {
    const int32_t n = d->train_steps;
    double product = 1.0;
    for (int32_t i = 0; i < n; i++) {
        product *= (double)(1.0f - gsf__nn_beta32(d, i));
        alpha_bar[i] = (double)(float)product;
    }
    if (d->no_zero_snr) return;
    const float first = sqrtf((float)alpha_bar[0]), last = sqrtf((float)alpha_bar[n - 1]), scale = first / (first - last);
    float before = 1.0f;
    product = 1.0;
    for (int32_t i = 0; i < n; i++) {
        const float root = (sqrtf((float)alpha_bar[i]) - last) * scale, bar = root * root;
        const float beta = 1.0f - bar / before;
        before = bar;
        product *= (double)(1.0f - beta);
        alpha_bar[i] = (double)(float)product;
    }
}

// (diffusers 0.32.1 scheduling_ddim_cogvideox.py)
static void gsf__nn_fill_cogx(const gsf_nn_schedule_desc* d, double* alpha_bar) {
    const int32_t n = d->train_steps;
    double product = 1.0;
    for (int32_t i = 0; i < n; i++) {
        product *= 1.0 - gsf__nn_beta64(d, i);
        alpha_bar[i] = product / (d->snr_shift_scale + (1.0 - d->snr_shift_scale) * product);
    }
    if (d->no_zero_snr) return;
    const double first = sqrt(alpha_bar[0]), last = sqrt(alpha_bar[n - 1]), scale = first / (first - last);
    for (int32_t i = 0; i < n; i++) {
        const double root = (sqrt(alpha_bar[i]) - last) * scale;
        alpha_bar[i] = root * root;
    }
}

static gsf_nn_schedule_desc gsf__nn_schedule_defaults(const gsf_nn_schedule_desc* desc) {
    gsf_nn_schedule_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.train_steps == 0) d.train_steps = 1000;
    if (d.beta_start == 0.0) d.beta_start = 0.00085;
    if (d.beta_end == 0.0) d.beta_end = 0.012;
    if (d.snr_shift_scale == 0.0) d.snr_shift_scale = 1.0;
    return d;
}

static gsf_result gsf__nn_check_schedule(gsf_context* ctx, const gsf_nn_schedule_desc* d) {
    if (d->train_steps < 2 || d->train_steps > 1000000)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "schedule: %d training steps", (int)d->train_steps);
    if (!(d->beta_start > 0.0 && d->beta_start <= d->beta_end && d->beta_end < 1.0))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "schedule: betas from %g to %g", d->beta_start, d->beta_end);
    if (!(d->snr_shift_scale > 0.0 && d->snr_shift_scale <= 1e6))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "schedule: snr_shift_scale %g", d->snr_shift_scale);
    if ((int)d->spacing < 0 || d->spacing > GSF_NN_LINSPACE || (int)d->table < 0 || d->table > GSF_NN_TABLE_COGX ||
        d->steps_offset < 0 || d->steps_offset >= d->train_steps)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "schedule: spacing %d, table %d, steps_offset %d", (int)d->spacing,
                        (int)d->table, (int)d->steps_offset);
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_make_schedule(gsf_context* ctx, const gsf_nn_schedule_desc* desc, gsf_nn_schedule* out) {
    memset(out, 0, sizeof *out);
    const gsf_nn_schedule_desc d = gsf__nn_schedule_defaults(desc);
    GSF__TRY(gsf__nn_check_schedule(ctx, &d));
    double* table = (double*)gsf_alloc(ctx, (size_t)d.train_steps, sizeof(double));
    if (!table) return GSF_ERROR_OUT_OF_MEMORY;
    if (d.table == GSF_NN_TABLE_COGX) gsf__nn_fill_cogx(&d, table);
    else gsf__nn_fill_ddim(&d, table);
    int falls = table[0] < 1.0 && table[d.train_steps - 1] >= 0.0; // a NaN fails
    for (int32_t i = 1; falls && i < d.train_steps; i++) falls = table[i] <= table[i - 1];
    if (!falls) {
        gsf_free(ctx, table);
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "schedule: betas from %g to %g over %d steps do not take 1 down to 0",
                        d.beta_start, d.beta_end, (int)d.train_steps);
    }
    out->desc = d;
    out->alpha_bar = table;
    out->final_alpha_bar = d.no_alpha_one ? table[0] : 1.0;
    return GSF_OK;
}

GSF_API void gsf_nn_destroy_schedule(gsf_context* ctx, gsf_nn_schedule* schedule) {
    gsf_free(ctx, schedule->alpha_bar);
    memset(schedule, 0, sizeof *schedule);
}

// The word of `words` (ended by NULL) that the key holds; others are unsupported.
static gsf_result gsf__nn_config_word(const gsf__nn_config* config, const char* key, const char* fallback,
                                      const char* const* words, int* out) {
    const char* text;
    GSF__TRY(gsf__nn_config_string(config, key, fallback, &text));
    for (*out = 0; words[*out]; ++*out)
        if (strcmp(text, words[*out]) == 0) return GSF_OK;
    return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: %s \"%s\" is not supported", config->json.name, key,
                    gsf__nn_show(text).text);
}

static gsf_result gsf__nn_config_refuse(const gsf__nn_config* config, const char* key, int fallback) {
    int flag;
    GSF__TRY(gsf__nn_config_bool_or(config, key, fallback, &flag));
    return flag ? gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: %s is not supported", config->json.name, key) : GSF_OK;
}

static gsf_result gsf__nn_read_schedule(const gsf__nn_config* config, gsf_nn_schedule_desc* d) {
    static const char* const schedules[] = {"scaled_linear", "linear", NULL};
    static const char* const spacings[] = {"trailing", "leading", "linspace", NULL};
    static const char* const predictions[] = {"v_prediction", NULL};
    int64_t whole;
    int flag;
    GSF__TRY(gsf__nn_config_word(config, "prediction_type", "epsilon", predictions, &flag));
    GSF__TRY(gsf__nn_config_refuse(config, "clip_sample", 1));
    GSF__TRY(gsf__nn_config_refuse(config, "thresholding", 0));
    if (gsf__nn_config_find(config, "trained_betas"))
        return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: trained_betas is not supported", config->json.name);
    GSF__TRY(gsf__nn_config_int_or(config, "num_train_timesteps", 1000, 2, 1000000, &whole));
    d->train_steps = (int32_t)whole;
    GSF__TRY(gsf__nn_config_int_or(config, "steps_offset", 0, 0, whole - 1, &whole));
    d->steps_offset = (int32_t)whole;
    GSF__TRY(gsf__nn_config_number_or(config, "beta_start", 0.0001, 1e-12, 0.999, &d->beta_start));
    GSF__TRY(gsf__nn_config_number_or(config, "beta_end", 0.02, d->beta_start, 0.999, &d->beta_end));
    GSF__TRY(gsf__nn_config_number_or(config, "snr_shift_scale", 1.0, 1e-3, 1e6, &d->snr_shift_scale));
    GSF__TRY(gsf__nn_config_word(config, "beta_schedule", "linear", schedules, &d->linear_betas));
    GSF__TRY(gsf__nn_config_bool_or(config, "rescale_betas_zero_snr", 0, &flag));
    d->no_zero_snr = !flag;
    GSF__TRY(gsf__nn_config_bool_or(config, "set_alpha_to_one", 1, &flag));
    d->no_alpha_one = !flag;
    GSF__TRY(gsf__nn_config_word(config, "timestep_spacing", "leading", spacings, &flag));
    d->spacing = (gsf_nn_spacing)flag;
    return GSF_OK;
}

static gsf_result gsf__nn_schedule_from(gsf_context* ctx, gsf__nn_config* config, gsf_nn_alpha_table table,
                                        gsf_nn_schedule* out) {
    gsf_nn_schedule_desc d;
    memset(&d, 0, sizeof d);
    d.table = table;
    gsf_result result = gsf__nn_read_schedule(config, &d);
    if (result == GSF_OK) result = gsf_nn_make_schedule(ctx, &d, out);
    gsf__nn_close_config(config);
    return result;
}

GSF_API gsf_result gsf_nn_parse_schedule(gsf_context* ctx, const char* name, const char* text, size_t size,
                                         gsf_nn_alpha_table table, gsf_nn_schedule* out) {
    gsf__nn_config config;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf__nn_parse_config(ctx, name, text, size, &config));
    return gsf__nn_schedule_from(ctx, &config, table, out);
}

GSF_API gsf_result gsf_nn_load_schedule(gsf_context* ctx, const char* path, gsf_nn_alpha_table table,
                                        gsf_nn_schedule* out) {
    gsf__nn_config config;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf__nn_load_config(ctx, path, &config));
    return gsf__nn_schedule_from(ctx, &config, table, out);
}

// One of the `steps` times before the cut by strength; numpy's arithmetic, half to even.
static int32_t gsf__nn_timestep(const gsf_nn_schedule_desc* d, int32_t steps, int32_t i) {
    const double n = d->train_steps;
    switch (d->spacing) {
        case GSF_NN_TRAILING: { // round(arange(n, 0, -n/steps)) - 1; arange adds multiples of its first difference
            const double difference = (n - n / steps) - n;
            return (int32_t)rint(n + i * difference) - 1;
        }
        case GSF_NN_LEADING: return (steps - 1 - i) * (d->train_steps / steps) + d->steps_offset;
        case GSF_NN_LINSPACE: { // round(linspace(0, n - 1, steps)) reversed
            if (steps == 1) return 0;
            return i == 0 ? d->train_steps - 1 : (int32_t)rint((steps - 1 - i) * ((n - 1.0) / (steps - 1)));
        }
    }
    return 0;
}

GSF_API gsf_result gsf_nn_make_timesteps(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t steps,
                                         double strength, int32_t* out, int32_t* count) {
    const gsf_nn_schedule_desc* d = &schedule->desc;
    *count = 0;
    if (steps < 1 || steps > d->train_steps)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%d steps, not 1 to %d", (int)steps, (int)d->train_steps);
    if (strength == 0.0) strength = 1.0;
    if (!(strength > 0.0 && strength <= 1.0))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "strength %g is not in (0, 1]", strength);
    const int32_t kept = (int32_t)(steps * strength);
    if (kept < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "strength %g of %d steps leaves none", strength, (int)steps);
    if (gsf__nn_timestep(d, steps, 0) >= d->train_steps)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "steps_offset %d takes %d steps past the table",
                        (int)d->steps_offset, (int)steps);
    for (int32_t i = steps - kept; i < steps; i++) out[(*count)++] = gsf__nn_timestep(d, steps, i);
    return GSF_OK;
}

// ---- elementwise work

typedef struct gsf__nn_step { // m: predicted clean latents; m0, m1: those of the last two steps; last: corrected latents
    double m_x, m_v;                        // m = m_x x + m_v v
    double c_last, c_m, c_m0, c_m1;         // x = c_last last + c_m m + c_m0 m0 + c_m1 m1, if `correct`
    double p_x, p_m, p_m0;                  // next x = p_x x + p_m m + p_m0 m0
    int correct;
    size_t count;
    const float *x_in, *v;
    float *x, *x0, *m0, *m1, *last;         // all but x may be NULL
} gsf__nn_step;

static void gsf__nn_step_chunk(void* arg, size_t chunk, int worker) {
    const gsf__nn_step* s = (const gsf__nn_step*)arg;
    (void)worker;
    const size_t begin = chunk * GSF__NN_CHUNK;
    const size_t end = begin + GSF__NN_CHUNK < s->count ? begin + GSF__NN_CHUNK : s->count;
    for (size_t i = begin; i < end; i++) {
        const double m0 = s->m0 ? (double)s->m0[i] : 0.0;
        double x = (double)s->x_in[i];
        const double m = s->m_x * x + s->m_v * (double)s->v[i];
        if (s->correct) x = s->c_last * (double)s->last[i] + s->c_m * m + s->c_m0 * m0 + s->c_m1 * (double)s->m1[i];
        s->x[i] = (float)(s->p_x * x + s->p_m * m + s->p_m0 * m0);
        if (s->x0) s->x0[i] = (float)m;
        if (s->last) s->last[i] = (float)x;
        if (s->m1) s->m1[i] = (float)m0;
        if (s->m0) s->m0[i] = (float)m;
    }
}

// out = a * x + b * y
static void gsf__nn_mix(gsf_context* ctx, double a, const float* x, double b, const float* y, size_t count, float* out) {
    gsf__nn_step job;
    memset(&job, 0, sizeof job);
    job.m_x = a;
    job.m_v = b;
    job.p_m = 1.0;
    job.count = count;
    job.x_in = x;
    job.v = y;
    job.x = out;
    gsf__parallel_for(ctx, (count + GSF__NN_CHUNK - 1) / GSF__NN_CHUNK, gsf__nn_step_chunk, &job);
}

GSF_API void gsf_nn_add_noise(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x0,
                              const float* noise, size_t count, float* out) {
    const double bar = schedule->alpha_bar[timestep];
    gsf__nn_mix(ctx, sqrt(bar), x0, sqrt(1.0 - bar), noise, count, out);
}

GSF_API void gsf_nn_make_velocity(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x0,
                                  const float* noise, size_t count, float* out) {
    const double bar = schedule->alpha_bar[timestep];
    gsf__nn_mix(ctx, -sqrt(1.0 - bar), x0, sqrt(bar), noise, count, out);
}

GSF_API void gsf_nn_predict_x0(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x,
                               const float* v, size_t count, float* out) {
    const double bar = schedule->alpha_bar[timestep];
    gsf__nn_mix(ctx, sqrt(bar), x, -sqrt(1.0 - bar), v, count, out);
}

// ---- solvers
/* With a = sqrt(abar), s = sqrt(1 - abar) and D(x) the predicted clean latents, the probability flow is
       d(x/s) = D du,  u = a/s = exp(lambda).
   DDIM holds D fixed over a step; DPM-Solver++(2M) and UniPC take it as linear (the corrector: as quadratic) in lambda. At
   zero SNR u is 0 and lambda -infinity. From there the first step is exact for constant D; a linear D is then taken in u,
   not in lambda, by the one step that would need that point. The last step ends at s = 0, where x is D. */

typedef struct gsf__nn_point { double a, s; } gsf__nn_point;

static gsf__nn_point gsf__nn_point_at(double alpha_bar) {
    gsf__nn_point p;
    p.a = sqrt(alpha_bar);
    p.s = sqrt(1.0 - alpha_bar);
    return p;
}

static gsf__nn_point gsf__nn_sampler_point(const gsf_nn_sampler* sampler, int32_t index) {
    return gsf__nn_point_at(sampler->schedule->alpha_bar[sampler->timesteps[index]]);
}

// Where the step from `index` leads.
static gsf__nn_point gsf__nn_sampler_target(const gsf_nn_sampler* sampler, int32_t index) {
    const gsf_nn_schedule* schedule = sampler->schedule;
    const int32_t next = sampler->desc.solver == GSF_NN_DDIM
                             ? sampler->timesteps[index] - schedule->desc.train_steps / sampler->desc.steps
                             : index + 1 < sampler->count ? sampler->timesteps[index + 1] : -1;
    return gsf__nn_point_at(next >= 0 ? schedule->alpha_bar[next] : schedule->final_alpha_bar);
}

// lambda(q) - lambda(p), both finite.
static double gsf__nn_lambda(gsf__nn_point p, gsf__nn_point q) { return log(q.a * p.s / (q.s * p.a)); }

// Predictor from p to t; q is the point before p, if second order is wanted.
static void gsf__nn_predictor(gsf__nn_step* step, gsf__nn_point p, gsf__nn_point t, const gsf__nn_point* q) {
    step->p_x = t.s / p.s;
    step->p_m = t.a - p.a * step->p_x; // t.a (1 - exp(-h))
    step->p_m0 = 0.0;
    if (!q || t.s == 0.0 || p.a == 0.0) return;
    double weight; // of m - m0
    if (q->a == 0.0) {
        const double u = p.a / p.s, rise = t.a / t.s - u;
        weight = t.s * rise * rise / (2.0 * u);
    } else {
        const double before = gsf__nn_lambda(*q, p);
        weight = before != 0.0 ? 0.5 * step->p_m * gsf__nn_lambda(p, t) / before : 0.0;
    }
    step->p_m += weight;
    step->p_m0 = -weight;
}

// UniC-2 with B(h) = exp(-h) - 1 at p, the step's own point, which was reached from m0's point o (before it m1's point n,
// NULL in the second step, where the corrector has first order): n -> o -> p.
static void gsf__nn_corrector(gsf__nn_step* step, const gsf__nn_point* n, gsf__nn_point o, gsf__nn_point p) {
    const double rise = p.a - o.a * p.s / o.s; // p.a (1 - exp(-h))
    double weight = 0.5, earlier = 0.0;        // of m - m0 and of m1 - m0
    if (n) {
        const double h = gsf__nn_lambda(o, p), phi = expm1(-h);
        const double phi2 = phi / -h - 1.0, phi3 = phi2 / -h - 0.5; // h_phi_2, h_phi_3 of UniPC's code
        weight = phi2 / phi;
        if (n->a != 0.0) {
            const double ratio = -gsf__nn_lambda(*n, o) / h, rho = (2.0 * phi3 / phi - weight) / (ratio - 1.0);
            earlier = rho / ratio;
            weight -= rho;
        }
    }
    step->correct = 1;
    step->c_last = p.s / o.s;
    step->c_m = rise * weight;
    step->c_m1 = rise * earlier;
    step->c_m0 = rise * (1.0 - weight - earlier);
}

GSF_API gsf_result gsf_nn_make_sampler(gsf_context* ctx, const gsf_nn_schedule* schedule, const gsf_nn_sampler_desc* desc,
                                       gsf_nn_sampler* out) {
    static const size_t kept[] = {0, 1, 3}; // blocks of memory for each solver
    gsf_nn_sampler sampler;
    memset(out, 0, sizeof *out);
    memset(&sampler, 0, sizeof sampler);
    sampler.desc = *desc;
    sampler.schedule = schedule;
    if (!sampler.desc.steps) sampler.desc.steps = 50;
    if ((int)desc->solver < 0 || desc->solver > GSF_NN_UNIPC || sampler.desc.steps < 1 ||
        sampler.desc.steps > schedule->desc.train_steps || !gsf__mul_size(desc->value_count, 3, &sampler.memory_count))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sampler: solver %d, %d steps, %zu values", (int)desc->solver,
                        (int)sampler.desc.steps, desc->value_count);
    sampler.memory_count = kept[desc->solver] * desc->value_count;
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    sampler.timesteps = (int32_t*)gsf_alloc(ctx, (size_t)sampler.desc.steps, sizeof(int32_t));
    if (sampler.timesteps) sampler.memory = (float*)gsf_alloc_zeroed(ctx, sampler.memory_count, sizeof(float));
    if (sampler.memory)
        result = gsf_nn_make_timesteps(ctx, schedule, sampler.desc.steps, desc->strength, sampler.timesteps,
                                       &sampler.count);
    if (result != GSF_OK) gsf_nn_destroy_sampler(ctx, &sampler);
    *out = sampler;
    return result;
}

GSF_API void gsf_nn_destroy_sampler(gsf_context* ctx, gsf_nn_sampler* sampler) {
    gsf_free(ctx, sampler->timesteps);
    gsf_free(ctx, sampler->memory);
    memset(sampler, 0, sizeof *sampler);
}

// A schedule that is no longer stretched to zero SNR, or a start below it, never meets a = 0.
static void gsf__nn_plan_step(const gsf_nn_sampler* sampler, gsf__nn_step* step) {
    const int32_t i = sampler->index;
    const size_t n = sampler->desc.value_count;
    const gsf__nn_point p = gsf__nn_sampler_point(sampler, i), t = gsf__nn_sampler_target(sampler, i);
    gsf__nn_point before[2]; // one and two steps earlier
    memset(before, 0, sizeof before);
    if (i > 0) before[0] = gsf__nn_sampler_point(sampler, i - 1);
    if (i > 1) before[1] = gsf__nn_sampler_point(sampler, i - 2);
    step->m_x = p.a;
    step->m_v = -p.s;
    const int second = sampler->desc.solver != GSF_NN_DDIM && i > 0 && i + 1 < sampler->count;
    gsf__nn_predictor(step, p, t, second ? &before[0] : NULL);
    if (sampler->desc.solver == GSF_NN_DDIM) return;
    step->m0 = sampler->memory;
    if (sampler->desc.solver != GSF_NN_UNIPC) return;
    step->m1 = sampler->memory + n;
    step->last = sampler->memory + 2 * n;
    if (i > 0) gsf__nn_corrector(step, i > 1 ? &before[1] : NULL, before[0], p);
}

GSF_API gsf_result gsf_nn_step_sampler(gsf_context* ctx, gsf_nn_sampler* sampler, const float* v, float* x, float* x0) {
    gsf__nn_step step;
    memset(&step, 0, sizeof step);
    if (sampler->index < 0 || sampler->index >= sampler->count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sampler: step %d of %d", (int)sampler->index,
                        (int)sampler->count);
    gsf__nn_plan_step(sampler, &step);
    step.count = sampler->desc.value_count;
    step.x_in = x;
    step.v = v;
    step.x = x;
    step.x0 = x0;
    gsf__parallel_for(ctx, (step.count + GSF__NN_CHUNK - 1) / GSF__NN_CHUNK, gsf__nn_step_chunk, &step);
    size_t bad = 0;
    for (size_t i = 0; i < step.count; i++) bad += !(fabsf(x[i]) <= FLT_MAX);
    if (bad)
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "step %d (time %d): %zu of %zu latents are NaN or infinite",
                        (int)sampler->index, (int)sampler->timesteps[sampler->index], bad, step.count);
    sampler->index++;
    return GSF_OK;
}

// ---- >>nn transformer -----------------------------------------------------------

// ---- >>nn vae -------------------------------------------------------------------

// ---- >>nn sampling --------------------------------------------------------------

// ---- >>nn restorer --------------------------------------------------------------

GSF__END_IMPLEMENTATION

#endif // GSF_NN_IMPLEMENTED
#endif // GSFIXER_NN_IMPLEMENTATION
