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

// ---- >>nn scheduler -------------------------------------------------------------

// ---- >>nn transformer -----------------------------------------------------------

// ---- >>nn vae -------------------------------------------------------------------

// ---- >>nn sampling --------------------------------------------------------------

// ---- >>nn restorer --------------------------------------------------------------

GSF__END_IMPLEMENTATION

#endif // GSF_NN_IMPLEMENTED
#endif // GSFIXER_NN_IMPLEMENTATION
