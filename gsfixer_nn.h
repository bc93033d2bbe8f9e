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
GSF__SHARED uint16_t gsf__float_to_bf16(float value) {
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
//
// Products x w^T by blocks (Goto and van de Geijn 2008; BLIS, Van Zee and van de Geijn 2015). What the innermost kernel
// reads is packed so that it lies in a line, the weights transposed and widened to float on the way:
//
//     x [group of 6 rows][k][6]        w [panel of 16 outputs][k][16]        sums [panel][group][6][16]
//
// A block of some hundred rows and outputs is one unit of parallel work. It goes through the inner dimension in steps of
// `depth`: that much of its rows lies in the L2 cache, of one panel in L1, and each tile of 6 x 16 sums is held in registers.
// After the last step a tile goes through bias, activation, gate and residual into y while it is hot. The weights are
// packed once per call for all blocks, or, where one block has all rows, by the worker that needs them. Up to 4 rows are a
// matter of reading the weights once: they are not packed but multiplied as they lie in the file.
// Sums: of each `depth` by itself, these then added in order; the same for any number of workers.

enum {
    GSF__TILE_ROWS = 6,
    GSF__TILE_COLUMNS = 16,
    GSF__TILE_SUMS = GSF__TILE_ROWS * GSF__TILE_COLUMNS,
    GSF__LINEAR_DEPTH = 256,          // a panel of it is 16 KiB: half of an L1 cache
    GSF__LINEAR_ROWS = 192,           // of a block; times depth: 192 KiB
    GSF__LINEAR_COLUMNS = 768,
    GSF__LINEAR_LONE_ROWS = 320,      // up to here one block has all rows
    GSF__LINEAR_LONE_COLUMNS = 192,
    GSF__FEW_ROWS = 4,                // up to here weights are not packed
    GSF__FEW_BYTES = 1 << 17,         // of weights in one unit of work
    GSF__FEW_COLUMNS = 1024           // and its most outputs
};

#ifndef GSF__LINEAR_PACKED // a test makes it small
#define GSF__LINEAR_PACKED ((int64_t)1 << 24) // most floats of packed weights held at a time: 64 MiB
#endif

typedef struct gsf__linear_job gsf__linear_job;

typedef struct gsf__linear_kernels { // one set per instruction set
    // out[k][16]: `columns` rows of weights, `pitch` bytes apart, as columns; zeros beyond them
    void (*pack_weights)(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t columns, int64_t count, float* out);
    // out[k][6]: `rows` rows of x as columns, zeros beyond them; may write two floats more
    void (*pack_rows)(const float* x, int64_t ldx, int64_t rows, int64_t count, float* out);
    // sums[6][16] = a[k][6]^T b[k][16], or += with `add`
    void (*tile)(const float* a, const float* b, int64_t count, int add, float* sums);
    // Sums (row stride `pitch`, readable to the next multiple of 8 columns) to outputs row ..., column ... of y
    void (*finish)(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row, int64_t rows, int64_t column,
                   int64_t columns);
    // sums[m*pitch + c] = row m of job->few times row column + c of the weights
    void (*few)(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums, int64_t pitch);
} gsf__linear_kernels;

typedef struct gsf__linear_plan { // how a product is cut; depends on its sizes only
    int64_t depth;                // of a step through the inner dimension
    int64_t block_rows, block_columns, row_blocks;
    int64_t group_columns;        // packed at a time
    int few, lone;                // up to 4 rows; one block has all rows
    size_t shared, per_worker;    // floats of scratch
} gsf__linear_plan;

struct gsf__linear_job {
    gsf_nn_linear_desc desc;
    gsf__linear_plan plan;
    const gsf__linear_kernels* kernels;
    int64_t in, out;
    int64_t first, columns;       // the group of outputs in work
    int64_t few_pitch;
    float *bias, *packed, *few;   // bias: zeros where there is none, 16 more than `out`
    float* workers;
};

static int64_t gsf__least(int64_t a, int64_t b) { return a < b ? a : b; }
static int64_t gsf__ceil_div(int64_t a, int64_t b) { return (a + b - 1) / b; }
static int64_t gsf__round_up(int64_t a, int64_t b) { return gsf__ceil_div(a, b) * b; }

// `total` in equal pieces of at most `most`, rounded up to a multiple of `unit`.
static int64_t gsf__even_piece(int64_t total, int64_t most, int64_t unit) {
    return gsf__round_up(gsf__ceil_div(total, gsf__ceil_div(total, most)), unit);
}

static float gsf__nn_load(const char* p, gsf_nn_dtype dtype) { // one weight: f32, bf16 or f16 at any address
    float value;
    uint16_t bits;
    if (dtype == GSF_NN_F32) {
        memcpy(&value, p, sizeof value);
        return value;
    }
    memcpy(&bits, p, sizeof bits);
    return dtype == GSF_NN_BF16 ? gsf__bf16_to_float(bits) : gsf__half_to_float(bits);
}

// ---- linear: scalar kernels

// The part of a panel at steps k ... and columns first ...
static void gsf__pack_corner(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t first, int64_t columns, int64_t k,
                             int64_t count, float* out) {
    const size_t size = gsf_nn_dtype_size(dtype);
    for (int64_t c = first; c < first + columns; c++)
        for (int64_t i = k; i < count; i++)
            out[i * GSF__TILE_COLUMNS + c] = gsf__nn_load(w + (size_t)c * pitch + (size_t)i * size, dtype);
}

static void gsf__pack_weights_scalar(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t columns, int64_t count,
                                     float* out) {
    if (columns < GSF__TILE_COLUMNS) memset(out, 0, (size_t)(count * GSF__TILE_COLUMNS) * sizeof(float));
    gsf__pack_corner(w, dtype, pitch, 0, columns, 0, count, out);
}

static void gsf__pack_rows_scalar(const float* x, int64_t ldx, int64_t rows, int64_t count, float* out) {
    for (int64_t r = 0; r < GSF__TILE_ROWS; r++)
        for (int64_t k = 0; k < count; k++) out[k * GSF__TILE_ROWS + r] = r < rows ? x[r * ldx + k] : 0.0f;
}

static void gsf__tile_scalar(const float* a, const float* b, int64_t count, int add, float* sums) {
    float c[GSF__TILE_SUMS];
    memset(c, 0, sizeof c);
    for (int64_t k = 0; k < count; k++, a += GSF__TILE_ROWS, b += GSF__TILE_COLUMNS)
        for (int i = 0; i < GSF__TILE_ROWS; i++)
            for (int j = 0; j < GSF__TILE_COLUMNS; j++) c[i * GSF__TILE_COLUMNS + j] += a[i] * b[j];
    for (int i = 0; i < GSF__TILE_SUMS; i++) sums[i] = add ? sums[i] + c[i] : c[i];
}

static void gsf__finish_scalar(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row, int64_t rows,
                               int64_t column, int64_t columns) {
    const gsf_nn_linear_desc* d = &job->desc;
    for (int64_t r = 0; r < rows; r++) {
        float* y = d->y + (row + r) * d->ldy + column;
        for (int64_t c = 0; c < columns; c++) {
            const float value = gsf__nn_activation_ref(d->activation, sums[r * pitch + c] + job->bias[column + c]);
            y[c] = d->gate ? y[c] + d->gate[column + c] * value : d->accumulate ? y[c] + value : value;
        }
    }
}

static void gsf__few_scalar(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums, int64_t pitch) {
    const gsf_nn_linear_desc* d = &job->desc;
    const size_t size = gsf_nn_dtype_size(d->weight->dtype);
    for (int64_t c = 0; c < columns; c++)
        for (int64_t m = 0; m < d->rows; m++) {
            const char* w = (const char*)d->weight->data + (size_t)(column + c) * (size_t)job->in * size;
            float sum = 0.0f;
            for (int64_t k = 0; k < job->in; k++, w += size)
                sum += job->few[m * job->few_pitch + k] * gsf__nn_load(w, d->weight->dtype);
            sums[m * pitch + c] = sum;
        }
}

static const gsf__linear_kernels gsf__linear_scalar = {gsf__pack_weights_scalar, gsf__pack_rows_scalar, gsf__tile_scalar,
                                                       gsf__finish_scalar, gsf__few_scalar};

// ---- linear: AVX2 kernels

#if GSF__X86

GSF__INLINE_AVX2 __m256 gsf__load8(const char* p, gsf_nn_dtype dtype) { // eight weights, widened
    if (dtype == GSF_NN_F32) return _mm256_loadu_ps((const float*)(const void*)p);
    const __m128i bits = _mm_loadu_si128((const __m128i*)(const void*)p);
    if (dtype == GSF_NN_F16) return _mm256_cvtph_ps(bits);
    return _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_cvtepu16_epi32(bits), 16));
}

// r0 ... r7: eight rows to eight columns, in place. A macro: gcc -O2 would keep an array in memory.
#define GSF__TRANSPOSE8(r)                                                                                               \
    {                                                                                                                    \
        const __m256 a0 = _mm256_unpacklo_ps(r##0, r##1), a1 = _mm256_unpackhi_ps(r##0, r##1);                           \
        const __m256 a2 = _mm256_unpacklo_ps(r##2, r##3), a3 = _mm256_unpackhi_ps(r##2, r##3);                           \
        const __m256 a4 = _mm256_unpacklo_ps(r##4, r##5), a5 = _mm256_unpackhi_ps(r##4, r##5);                           \
        const __m256 a6 = _mm256_unpacklo_ps(r##6, r##7), a7 = _mm256_unpackhi_ps(r##6, r##7);                           \
        const __m256 b0 = _mm256_shuffle_ps(a0, a2, 0x44), b1 = _mm256_shuffle_ps(a0, a2, 0xee);                         \
        const __m256 b2 = _mm256_shuffle_ps(a1, a3, 0x44), b3 = _mm256_shuffle_ps(a1, a3, 0xee);                         \
        const __m256 b4 = _mm256_shuffle_ps(a4, a6, 0x44), b5 = _mm256_shuffle_ps(a4, a6, 0xee);                         \
        const __m256 b6 = _mm256_shuffle_ps(a5, a7, 0x44), b7 = _mm256_shuffle_ps(a5, a7, 0xee);                         \
        r##0 = _mm256_permute2f128_ps(b0, b4, 0x20);                                                                     \
        r##1 = _mm256_permute2f128_ps(b1, b5, 0x20);                                                                     \
        r##2 = _mm256_permute2f128_ps(b2, b6, 0x20);                                                                     \
        r##3 = _mm256_permute2f128_ps(b3, b7, 0x20);                                                                     \
        r##4 = _mm256_permute2f128_ps(b0, b4, 0x31);                                                                     \
        r##5 = _mm256_permute2f128_ps(b1, b5, 0x31);                                                                     \
        r##6 = _mm256_permute2f128_ps(b2, b6, 0x31);                                                                     \
        r##7 = _mm256_permute2f128_ps(b3, b7, 0x31);                                                                     \
    }

GSF__INLINE_AVX2 void gsf__pack_weights8(const char* w, gsf_nn_dtype dtype, size_t size, size_t pitch, int64_t columns,
                                         int64_t count, float* out) {
    const int64_t whole = count & ~(int64_t)7;
    if (columns < GSF__TILE_COLUMNS) memset(out, 0, (size_t)(count * GSF__TILE_COLUMNS) * sizeof(float));
    for (int64_t c = 0; c < columns; c += 8) {
        if (columns - c < 8) {
            gsf__pack_corner(w, dtype, pitch, c, columns - c, 0, count, out);
            break;
        }
        const char* p = w + (size_t)c * pitch;
        float* to = out + c;
        for (int64_t k = 0; k < whole; k += 8, p += 8 * size, to += 8 * GSF__TILE_COLUMNS) {
            __m256 r0 = gsf__load8(p, dtype), r1 = gsf__load8(p + pitch, dtype);
            __m256 r2 = gsf__load8(p + 2 * pitch, dtype), r3 = gsf__load8(p + 3 * pitch, dtype);
            __m256 r4 = gsf__load8(p + 4 * pitch, dtype), r5 = gsf__load8(p + 5 * pitch, dtype);
            __m256 r6 = gsf__load8(p + 6 * pitch, dtype), r7 = gsf__load8(p + 7 * pitch, dtype);
            GSF__TRANSPOSE8(r)
            _mm256_store_ps(to, r0);
            _mm256_store_ps(to + 16, r1);
            _mm256_store_ps(to + 32, r2);
            _mm256_store_ps(to + 48, r3);
            _mm256_store_ps(to + 64, r4);
            _mm256_store_ps(to + 80, r5);
            _mm256_store_ps(to + 96, r6);
            _mm256_store_ps(to + 112, r7);
        }
        gsf__pack_corner(w, dtype, pitch, c, 8, whole, count, out);
    }
}

GSF__TARGET_AVX2 static void gsf__pack_weights_avx2(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t columns,
                                                    int64_t count, float* out) {
    if (dtype == GSF_NN_F32) gsf__pack_weights8(w, GSF_NN_F32, 4, pitch, columns, count, out);
    else if (dtype == GSF_NN_BF16) gsf__pack_weights8(w, GSF_NN_BF16, 2, pitch, columns, count, out);
    else gsf__pack_weights8(w, GSF_NN_F16, 2, pitch, columns, count, out);
}

GSF__TARGET_AVX2 static void gsf__pack_rows_avx2(const float* x, int64_t ldx, int64_t rows, int64_t count, float* out) {
    static const float zeros[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    const float* p[GSF__TILE_ROWS];
    int64_t step[GSF__TILE_ROWS]; // all bits, or 0 for a row that is not there
    const int64_t whole = count & ~(int64_t)7;
    float* to = out;
    for (int64_t r = 0; r < GSF__TILE_ROWS; r++) {
        p[r] = r < rows ? x + r * ldx : zeros;
        step[r] = r < rows ? -1 : 0;
    }
    for (int64_t k = 0; k < whole; k += 8, to += 8 * GSF__TILE_ROWS) {
        __m256 r0 = _mm256_loadu_ps(p[0] + (k & step[0])), r1 = _mm256_loadu_ps(p[1] + (k & step[1]));
        __m256 r2 = _mm256_loadu_ps(p[2] + (k & step[2])), r3 = _mm256_loadu_ps(p[3] + (k & step[3]));
        __m256 r4 = _mm256_loadu_ps(p[4] + (k & step[4])), r5 = _mm256_loadu_ps(p[5] + (k & step[5]));
        __m256 r6 = _mm256_setzero_ps(), r7 = r6;
        GSF__TRANSPOSE8(r)
        _mm256_storeu_ps(to, r0); // each writes two floats too many, which the next one takes back
        _mm256_storeu_ps(to + 6, r1);
        _mm256_storeu_ps(to + 12, r2);
        _mm256_storeu_ps(to + 18, r3);
        _mm256_storeu_ps(to + 24, r4);
        _mm256_storeu_ps(to + 30, r5);
        _mm256_storeu_ps(to + 36, r6);
        _mm256_storeu_ps(to + 42, r7);
    }
    for (int64_t k = whole; k < count; k++)
        for (int i = 0; i < GSF__TILE_ROWS; i++) out[k * GSF__TILE_ROWS + i] = i < rows ? p[i][k] : 0.0f;
}

GSF__TARGET_AVX2 static void gsf__tile_avx2(const float* a, const float* b, int64_t count, int add, float* sums) {
    // 12 registers of sums, 2 of b, 1 or 2 of a; named, as gcc would keep an array in memory
    __m256 c00 = _mm256_setzero_ps(), c01 = c00, c10 = c00, c11 = c00, c20 = c00, c21 = c00;
    __m256 c30 = c00, c31 = c00, c40 = c00, c41 = c00, c50 = c00, c51 = c00;
#define GSF_ROW(i, at)                               \
    v = _mm256_broadcast_ss(a + (at));               \
    c##i##0 = _mm256_fmadd_ps(v, b0, c##i##0);       \
    c##i##1 = _mm256_fmadd_ps(v, b1, c##i##1);
#define GSF_STEP(u)                                                                                             \
    {                                                                                                           \
        const __m256 b0 = _mm256_load_ps(b + 16 * (u)), b1 = _mm256_load_ps(b + 16 * (u) + 8);                   \
        __m256 v;                                                                                               \
        GSF_ROW(0, 6 * (u)) GSF_ROW(1, 6 * (u) + 1) GSF_ROW(2, 6 * (u) + 2)                                      \
        GSF_ROW(3, 6 * (u) + 3) GSF_ROW(4, 6 * (u) + 4) GSF_ROW(5, 6 * (u) + 5)                                  \
    }
    for (; count >= 4; count -= 4, a += 4 * 6, b += 4 * 16) {
        GSF_STEP(0)
        GSF_STEP(1)
        GSF_STEP(2)
        GSF_STEP(3)
    }
    for (; count > 0; count--, a += 6, b += 16) GSF_STEP(0)
#define GSF_X(i)                                                                                                \
    _mm256_store_ps(sums + 16 * i, add ? _mm256_add_ps(_mm256_load_ps(sums + 16 * i), c##i##0) : c##i##0);       \
    _mm256_store_ps(sums + 16 * i + 8, add ? _mm256_add_ps(_mm256_load_ps(sums + 16 * i + 8), c##i##1) : c##i##1);
    GSF_X(0) GSF_X(1) GSF_X(2) GSF_X(3) GSF_X(4) GSF_X(5)
#undef GSF_X
#undef GSF_STEP
#undef GSF_ROW
}

// Eight activations at a time.
GSF__INLINE_AVX2 __m256 gsf__linear_activate8(gsf_nn_activation activation, __m256 x) {
    float v[8];
    if (activation == GSF_NN_LINEAR) return x;
    _mm256_storeu_ps(v, x);
    for (int i = 0; i < 8; i++) v[i] = gsf__nn_activation_ref(activation, v[i]);
    return _mm256_loadu_ps(v);
}

GSF__TARGET_AVX2 static void gsf__finish_avx2(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row,
                                              int64_t rows, int64_t column, int64_t columns) {
    static const int32_t lanes[16] = {-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0};
    const gsf_nn_linear_desc* d = &job->desc;
    for (int64_t c = 0; c < columns; c += 8) {
        const int64_t n = gsf__least(columns - c, 8);
        const __m256i mask = _mm256_loadu_si256((const __m256i*)(const void*)(lanes + 8 - n));
        const __m256 bias = _mm256_loadu_ps(job->bias + column + c);
        const __m256 gate = d->gate ? _mm256_maskload_ps(d->gate + column + c, mask) : _mm256_set1_ps(1.0f);
        for (int64_t r = 0; r < rows; r++) {
            float* y = d->y + (row + r) * d->ldy + column + c;
            __m256 v = _mm256_add_ps(_mm256_loadu_ps(sums + r * pitch + c), bias);
            v = gsf__linear_activate8(d->activation, v);
            if (d->gate || d->accumulate) v = _mm256_fmadd_ps(gate, v, _mm256_maskload_ps(y, mask));
            if (n == 8) _mm256_storeu_ps(y, v);
            else _mm256_maskstore_ps(y, mask, v);
        }
    }
}

// Sixteen weights in two registers, in the order in which gsf__few_order put x.
GSF__INLINE_AVX2 void gsf__load16(const char* p, gsf_nn_dtype dtype, __m256* low, __m256* high) {
    if (dtype == GSF_NN_BF16) { // a float's upper half: even ones by a shift, odd ones by a mask
        const __m256i bits = _mm256_loadu_si256((const __m256i*)(const void*)p);
        *low = _mm256_castsi256_ps(_mm256_slli_epi32(bits, 16));
        *high = _mm256_castsi256_ps(_mm256_and_si256(bits, _mm256_set1_epi32((int)0xffff0000u)));
    } else {
        *low = gsf__load8(p, dtype);
        *high = gsf__load8(p + 8 * (dtype == GSF_NN_F32 ? 4 : 2), dtype);
    }
}

GSF__INLINE_AVX2 float gsf__sum8(__m256 v) {
    __m128 s = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    s = _mm_add_ps(s, _mm_movehl_ps(s, s));
    return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}

// Two rows of weights times one row of x (padded with zeros to a multiple of 16).
GSF__INLINE_AVX2 void gsf__few_one(const char* w0, const char* w1, gsf_nn_dtype dtype, const float* x, int64_t count,
                                   __m256* sums) {
    __m256 s00 = sums[0], s01 = sums[1], s10 = sums[2], s11 = sums[3], a, b;
    const size_t step = dtype == GSF_NN_F32 ? 64 : 32;
    for (; count > 0; count -= 16, x += 16, w0 += step, w1 += step) {
        const __m256 x0 = _mm256_load_ps(x), x1 = _mm256_load_ps(x + 8);
        gsf__load16(w0, dtype, &a, &b);
        s00 = _mm256_fmadd_ps(a, x0, s00);
        s01 = _mm256_fmadd_ps(b, x1, s01);
        gsf__load16(w1, dtype, &a, &b);
        s10 = _mm256_fmadd_ps(a, x0, s10);
        s11 = _mm256_fmadd_ps(b, x1, s11);
    }
    sums[0] = s00;
    sums[1] = s01;
    sums[2] = s10;
    sums[3] = s11;
}

// Two rows of weights times four rows of x.
GSF__INLINE_AVX2 void gsf__few_four(const char* w0, const char* w1, gsf_nn_dtype dtype, const float* x, int64_t pitch,
                                    int64_t count, __m256* sums) {
    __m256 s00 = sums[0], s01 = sums[1], s02 = sums[2], s03 = sums[3];
    __m256 s10 = sums[4], s11 = sums[5], s12 = sums[6], s13 = sums[7], a0, b0, a1, b1, v;
    const size_t step = dtype == GSF_NN_F32 ? 64 : 32;
    for (; count > 0; count -= 16, x += 16, w0 += step, w1 += step) {
        gsf__load16(w0, dtype, &a0, &b0);
        gsf__load16(w1, dtype, &a1, &b1);
#define GSF_X(m)                                                \
        v = _mm256_load_ps(x + (m) * pitch);                    \
        s0##m = _mm256_fmadd_ps(a0, v, s0##m);                  \
        s1##m = _mm256_fmadd_ps(a1, v, s1##m);                  \
        v = _mm256_load_ps(x + (m) * pitch + 8);                \
        s0##m = _mm256_fmadd_ps(b0, v, s0##m);                  \
        s1##m = _mm256_fmadd_ps(b1, v, s1##m);
        GSF_X(0) GSF_X(1) GSF_X(2) GSF_X(3)
#undef GSF_X
    }
    sums[0] = s00;
    sums[1] = s01;
    sums[2] = s02;
    sums[3] = s03;
    sums[4] = s10;
    sums[5] = s11;
    sums[6] = s12;
    sums[7] = s13;
}

GSF__INLINE_AVX2 void gsf__few8(const gsf__linear_job* job, gsf_nn_dtype dtype, size_t size, int64_t column, int64_t columns,
                                float* sums, int64_t pitch) {
    const char* w = (const char*)job->desc.weight->data + (size_t)column * (size_t)job->in * size;
    const int64_t whole = job->in & ~(int64_t)15, rest = job->in - whole;
    const float* x = job->few;
    for (int64_t c = 0; c < columns; c += 2) {
        const char* w0 = w + (size_t)c * (size_t)job->in * size;
        const char* w1 = c + 1 < columns ? w0 + (size_t)job->in * size : w0;
        char tail[2][64]; // what is left of the two rows, then zeros
        __m256 s[8];
        for (int i = 0; i < 8; i++) s[i] = _mm256_setzero_ps();
        if (rest) {
            memset(tail, 0, sizeof tail);
            memcpy(tail[0], w0 + (size_t)whole * size, (size_t)rest * size);
            memcpy(tail[1], w1 + (size_t)whole * size, (size_t)rest * size);
        }
        if (job->desc.rows == 1) {
            gsf__few_one(w0, w1, dtype, x, whole, s);
            if (rest) gsf__few_one(tail[0], tail[1], dtype, x + whole, 16, s);
            sums[c] = gsf__sum8(_mm256_add_ps(s[0], s[1]));
            if (c + 1 < columns) sums[c + 1] = gsf__sum8(_mm256_add_ps(s[2], s[3]));
        } else {
            gsf__few_four(w0, w1, dtype, x, job->few_pitch, whole, s);
            if (rest) gsf__few_four(tail[0], tail[1], dtype, x + whole, job->few_pitch, 16, s);
            for (int64_t m = 0; m < job->desc.rows; m++) {
                sums[m * pitch + c] = gsf__sum8(s[m]);
                if (c + 1 < columns) sums[m * pitch + c + 1] = gsf__sum8(s[4 + m]);
            }
        }
    }
}

GSF__TARGET_AVX2 static void gsf__few_avx2(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums,
                                           int64_t pitch) {
    const gsf_nn_dtype dtype = job->desc.weight->dtype;
    if (dtype == GSF_NN_F32) gsf__few8(job, GSF_NN_F32, 4, column, columns, sums, pitch);
    else if (dtype == GSF_NN_BF16) gsf__few8(job, GSF_NN_BF16, 2, column, columns, sums, pitch);
    else gsf__few8(job, GSF_NN_F16, 2, column, columns, sums, pitch);
}

static const gsf__linear_kernels gsf__linear_avx2 = {gsf__pack_weights_avx2, gsf__pack_rows_avx2, gsf__tile_avx2,
                                                     gsf__finish_avx2, gsf__few_avx2};

#endif

static const gsf__linear_kernels* gsf__linear_kernels_of(gsf_cpu_level level) {
#if GSF__X86
    if (level >= GSF_CPU_AVX2) return &gsf__linear_avx2;
#endif
    (void)level;
    return &gsf__linear_scalar;
}

// ---- linear: the parts put together

static void gsf__linear_pack_panel(void* arg, size_t panel, int worker) { // of the group in work, all of its depth
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const gsf_tensor* w = job->desc.weight;
    const int64_t at = (int64_t)panel * GSF__TILE_COLUMNS, left = job->columns - at;
    const size_t pitch = (size_t)job->in * gsf_nn_dtype_size(w->dtype);
    (void)worker;
    job->kernels->pack_weights((const char*)w->data + (size_t)(job->first + at) * pitch, w->dtype, pitch,
                               gsf__least(left, GSF__TILE_COLUMNS), job->in, job->packed + at * job->in);
}

// All tiles of one panel at one step.
static void gsf__linear_panel(const gsf__linear_job* job, const float* x, const float* w, float* sums, int64_t k,
                              int64_t count, int64_t row, int64_t rows, int64_t column, int64_t columns) {
    for (int64_t r = 0; r < rows; r += GSF__TILE_ROWS, sums += GSF__TILE_SUMS) {
        job->kernels->tile(x + r * count, w, count, k > 0, sums);
        if (k + count == job->in)
            job->kernels->finish(job, sums, GSF__TILE_COLUMNS, row + r, gsf__least(rows - r, GSF__TILE_ROWS), column, columns);
    }
}

static void gsf__linear_block(void* arg, size_t index, int worker) { // a block of rows and outputs
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const gsf__linear_plan* plan = &job->plan;
    const gsf_nn_linear_desc* d = &job->desc;
    const int64_t row = (int64_t)index % plan->row_blocks * plan->block_rows;
    const int64_t at = (int64_t)index / plan->row_blocks * plan->block_columns; // in the group
    const int64_t rows = gsf__least(d->rows - row, plan->block_rows);
    const int64_t columns = gsf__least(job->columns - at, plan->block_columns);
    const int64_t tiles = gsf__ceil_div(rows, GSF__TILE_ROWS);
    const size_t size = gsf_nn_dtype_size(d->weight->dtype), pitch = (size_t)job->in * size;
    float* sums = job->workers + (size_t)worker * plan->per_worker;
    float* panel = sums + plan->block_rows * plan->block_columns; // both whole tiles
    float* x = panel + (plan->lone ? plan->depth * GSF__TILE_COLUMNS : 0);
    for (int64_t k = 0; k < job->in; k += plan->depth) {
        const int64_t count = job->in - k < plan->depth ? job->in - k : plan->depth;
        for (int64_t r = 0; r < rows; r += GSF__TILE_ROWS)
            job->kernels->pack_rows(d->x + (row + r) * d->ldx + k, d->ldx, gsf__least(rows - r, GSF__TILE_ROWS), count,
                                    x + r * count);
        for (int64_t c = 0; c < columns; c += GSF__TILE_COLUMNS) {
            const int64_t width = gsf__least(columns - c, GSF__TILE_COLUMNS);
            const int64_t column = job->first + at + c;
            const float* w = plan->lone ? panel : job->packed + (at + c) * job->in + k * GSF__TILE_COLUMNS;
            if (plan->lone)
                job->kernels->pack_weights((const char*)d->weight->data + (size_t)column * pitch + (size_t)k * size,
                                           d->weight->dtype, pitch, width, count, panel);
            gsf__linear_panel(job, x, w, sums + c / GSF__TILE_COLUMNS * tiles * GSF__TILE_SUMS, k, count, row, rows, column,
                              width);
        }
    }
}

static void gsf__linear_few(void* arg, size_t index, int worker) { // some outputs of all rows
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const int64_t at = (int64_t)index * job->plan.block_columns;
    const int64_t columns = gsf__least(job->out - at, job->plan.block_columns);
    float* sums = job->workers + (size_t)worker * job->plan.per_worker;
    job->kernels->few(job, at, columns, sums, job->plan.block_columns);
    job->kernels->finish(job, sums, job->plan.block_columns, 0, job->desc.rows, at, columns);
}

// x to rows of a multiple of 16, zeros behind; for the bf16 kernel the even ones of each 16 first.
static void gsf__few_order(gsf__linear_job* job, int even_first) {
    for (int64_t m = 0; m < GSF__FEW_ROWS; m++)
        for (int64_t k = 0; k < job->few_pitch; k++) {
            const int64_t from = even_first ? (k & ~(int64_t)15) + 2 * (k & 7) + (k >> 3 & 1) : k;
            const int there = m < job->desc.rows && from < job->in;
            job->few[m * job->few_pitch + k] = there ? job->desc.x[m * job->desc.ldx + from] : 0.0f;
        }
}

// Cuts (rows, in) x (out, in)^T; 0 where the scratch would not be addressable.
static int gsf__plan_linear(int64_t rows, int64_t in, int64_t out, size_t weight_size, gsf__linear_plan* plan) {
    memset(plan, 0, sizeof *plan);
    if (in > INT64_MAX / 256 || out > INT64_MAX / 256 || rows > INT64_MAX / 256) return 0;
    size_t shared = 0;
    if (rows <= GSF__FEW_ROWS) {
        const int64_t fit = GSF__FEW_BYTES / (in * (int64_t)weight_size);
        plan->few = 1;
        plan->block_columns = gsf__round_up(gsf__least(fit < 1 ? 1 : fit, GSF__FEW_COLUMNS), 16);
        plan->per_worker = (size_t)(plan->block_columns * GSF__FEW_ROWS);
        shared = (size_t)gsf__round_up(in, 16) * GSF__FEW_ROWS;
    } else {
        plan->lone = rows <= GSF__LINEAR_LONE_ROWS;
        plan->depth = gsf__even_piece(in, GSF__LINEAR_DEPTH, 8);
        plan->block_rows = gsf__even_piece(rows, plan->lone ? GSF__LINEAR_LONE_ROWS : GSF__LINEAR_ROWS, GSF__TILE_ROWS);
        plan->row_blocks = gsf__ceil_div(rows, plan->block_rows);
        const int64_t most = GSF__LINEAR_PACKED / in / GSF__TILE_COLUMNS * GSF__TILE_COLUMNS;
        const int64_t widest = plan->lone ? GSF__LINEAR_LONE_COLUMNS : GSF__LINEAR_COLUMNS;
        plan->group_columns = plan->lone ? out : gsf__even_piece(out, most < 16 ? 16 : most, GSF__TILE_COLUMNS);
        plan->block_columns = gsf__even_piece(plan->group_columns, widest, GSF__TILE_COLUMNS);
        plan->per_worker = (size_t)(plan->block_rows * (plan->block_columns + plan->depth) + GSF__TILE_COLUMNS);
        if (plan->lone) plan->per_worker += (size_t)(plan->depth * GSF__TILE_COLUMNS);
        else if (!gsf__mul_size((size_t)gsf__round_up(plan->group_columns, GSF__TILE_COLUMNS), (size_t)in, &shared)) return 0;
    }
    plan->per_worker = (size_t)gsf__round_up((int64_t)plan->per_worker, 16); // workers begin on cache lines
    plan->shared = shared + (size_t)gsf__round_up(out + 16, 16);
    return plan->shared >= shared;
}

static gsf_result gsf__check_linear(gsf_context* ctx, const gsf_nn_linear_desc* desc, int64_t* in, int64_t* out) {
    const gsf_tensor* w = desc->weight;
    if (!desc->x || !desc->y || !w || !w->data || desc->rows < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: x, y or weight is missing");
    const char* name = w->name ? w->name : "weight";
    if (w->rank < 2 || w->shape[0] < 1 || w->count / w->shape[0] < 1 || w->count % w->shape[0])
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: %s is no matrix", name);
    if (w->dtype != GSF_NN_F32 && w->dtype != GSF_NN_BF16 && w->dtype != GSF_NN_F16)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "linear: %s is %s", name, gsf_nn_dtype_name(w->dtype));
    *out = w->shape[0];
    *in = w->count / w->shape[0];
    if (desc->bias && (desc->bias->count != *out || !desc->bias->data))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: %s has %lld values, not %lld",
                        desc->bias->name ? desc->bias->name : "bias", (long long)desc->bias->count, (long long)*out);
    if ((desc->ldx && desc->ldx < *in) || (desc->ldy && desc->ldy < *out))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: rows of %lld and %lld values, but %s is (%lld, %lld)",
                        (long long)desc->ldx, (long long)desc->ldy, name, (long long)*out, (long long)*in);
    return GSF_OK;
}

static void gsf__run_linear(gsf_context* ctx, gsf__linear_job* job) { // scratch is there
    const gsf__linear_plan* plan = &job->plan;
    memset(job->bias, 0, (size_t)(job->out + 16) * sizeof(float));
    if (job->desc.bias) gsf_nn_read_tensor(job->desc.bias, 0, job->out, job->bias);
    if (plan->few) {
        gsf__few_order(job, job->desc.weight->dtype == GSF_NN_BF16 && job->kernels != &gsf__linear_scalar);
        gsf__parallel_for(ctx, (size_t)gsf__ceil_div(job->out, plan->block_columns), gsf__linear_few, job);
        return;
    }
    for (job->first = 0; job->first < job->out; job->first += plan->group_columns) {
        job->columns = gsf__least(job->out - job->first, plan->group_columns);
        if (!plan->lone)
            gsf__parallel_for(ctx, (size_t)gsf__ceil_div(job->columns, GSF__TILE_COLUMNS), gsf__linear_pack_panel, job);
        const int64_t blocks = plan->row_blocks * gsf__ceil_div(job->columns, plan->block_columns);
        gsf__parallel_for(ctx, (size_t)blocks, gsf__linear_block, job);
    }
}

GSF_API gsf_result gsf_nn_linear(gsf_context* ctx, gsf_nn_workspace* workspace, const gsf_nn_linear_desc* desc) {
    gsf_nn_workspace own;
    gsf__linear_job job;
    size_t floats, bytes;
    memset(&own, 0, sizeof own);
    memset(&job, 0, sizeof job);
    GSF__TRY(gsf__check_linear(ctx, desc, &job.in, &job.out));
    if (desc->rows == 0) return GSF_OK;
    job.desc = *desc;
    if (!job.desc.ldx) job.desc.ldx = job.in;
    if (!job.desc.ldy) job.desc.ldy = job.out;
    if (!gsf__plan_linear(desc->rows, job.in, job.out, gsf_nn_dtype_size(desc->weight->dtype), &job.plan) ||
        !gsf__mul_size(job.plan.per_worker, (size_t)ctx->parallel.worker_count, &floats) ||
        floats > SIZE_MAX - job.plan.shared || !gsf__mul_size(floats + job.plan.shared, sizeof(float), &bytes))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "linear: %lld rows x %lld x %lld", (long long)desc->rows,
                        (long long)job.in, (long long)job.out);
    float* scratch = (float*)gsf__nn_scratch(ctx, workspace ? workspace : &own, bytes);
    if (!scratch) return GSF_ERROR_OUT_OF_MEMORY;
    job.kernels = gsf__linear_kernels_of(ctx->cpu_level);
    job.workers = scratch;
    job.bias = scratch + floats;
    job.few_pitch = gsf__round_up(job.in, 16);
    job.packed = job.few = job.bias + gsf__round_up(job.out + 16, 16);
    gsf__run_linear(ctx, &job);
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

// ---- >>nn scheduler -------------------------------------------------------------

// ---- >>nn transformer -----------------------------------------------------------

// ---- >>nn vae -------------------------------------------------------------------

// ---- >>nn sampling --------------------------------------------------------------

// ---- >>nn restorer --------------------------------------------------------------

GSF__END_IMPLEMENTATION

#endif // GSF_NN_IMPLEMENTED
#endif // GSFIXER_NN_IMPLEMENTATION
