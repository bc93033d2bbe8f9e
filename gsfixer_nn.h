/* gsfixer_nn.h - tensors, kernels and the networks of the reference-guided video restorer
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       In exactly one C (C11) or C++ (C++17) file:
           #define GSFIXER_IMPLEMENTATION      // or GSFIXER_NN_IMPLEMENTATION for this module only
           #include "gsfixer_nn.h"             // includes gsfixer.h by itself
       Everywhere else include it without the define. This module does not depend on splats: the repair loop sees the
       restorer only through the interface in gsfixer.h.

   WHAT IT DOES NOT DO
       No automatic differentiation, no graph: the networks are straight-line C, and the gradients of layers are written
       by hand. It neither converts nor downloads weight files.

   CONVENTIONS
       tensors         dense, row-major, the last dimension contiguous; shapes are written (rows, columns)
       activations     float32; weights as stored in the file (f32, bf16 or f16), widened to float32 while being packed
       linear layers   y = x w^T + b with w (out, in), as PyTorch stores it
       video           VAE: (channels, frames, height, width); transformer and latents: (frames, channels, height, width)
       pixels          [-1, 1] for the VAE, [0, 1] for the restorer

   STEP BY STEP (restore a clip with the paper's model; gsf_nn_make_dit does the same behind gsfixer.h's interface)
       gsf_nn_transformer transformer;
       gsf_nn_vae vae;
       gsf_nn_schedule schedule;
       gsf_nn_load_transformer(&ctx, "MODEL/transformer", &transformer);
       gsf_nn_load_vae(&ctx, "MODEL/vae", &vae);
       gsf_nn_load_schedule(&ctx, "MODEL/scheduler/scheduler_config.json", &schedule);
       gsf_nn_project_references(&ctx, &transformer, tokens, dino, vggt, references);
       gsf_nn_sample_desc desc;
       memset(&desc, 0, sizeof desc);                     // zero is the default everywhere
       desc.frames = 49; desc.height = 480; desc.width = 720;
       desc.control = rendered; desc.text = embeddings; desc.references = references; desc.reference_tokens = tokens;
       gsf_nn_sample(&ctx, &transformer, &vae, &schedule, &desc, restored, NULL);   // check every result

   MEMORY      Weight files are memory-mapped where the platform supports it (otherwise read whole) and used in place:
               mapped tensors that are never used are not read from disk. The kernels' scratch memory grows to the
               largest need of a call and is reused within it.
   THREADS     As in gsfixer.h: results are bit-identical for any number of workers.
   PROCESSORS  Elementwise kernels are written once over the lanes of gsfixer.h, next to a scalar reference. The inner
               loops of GEMM, GEMV, attention and convolution are hand-written for AVX2 and AVX-512. 8-bit layers use
               byte dot products (VNNI); linear layers and attention use bfloat16 dot products if the `bf16` member of
               their descriptor is set. gsf_context.cpu_level selects the level; results differ between levels by the
               rounding of float32 sums.
   SOURCES     GSFixer (Yin et al. 2025); CogVideoX (Yang et al. 2024); DDIM (Song et al. 2021), zero terminal SNR (Lin et
               al. 2024); online softmax (Milakov and Gimelshein 2018), FlashAttention (Dao et al. 2022); SentencePiece
               (Kudo and Richardson 2018), T5 (Raffel et al. 2020).
   WHERE TO ADD
       an activation    gsf__nn_activation in >>nn kernels; in >>nn activations the scalar gsf__nn_activation_ref, the vector
                        gsf__v_activate (without a case it returns x) and the list in gsf__activate; its slope in >>nn
                        training: gsf__nn_activation_slope, gsf__v_slope (without a case it returns 1) and the list in
                        gsf__activate_grad; its name in config.json: gsf__nn_config_read_key in >>nn files, an array and
                        a string in the same order. Linear and 8-bit layers need no change. DINOv2, BLIP-2 (encoder,
                        Q-Former) and OPT choose theirs by config; the other networks have fixed ones. Tests:
                        GSF__NN_ACTIVATION_COUNT, beside the enum, and activation_of in tests/activation.h
       a network        a table of layers as in >>nn image encoders, opened by gsf__nn_open_network, run with the layers
                        of >>nn layers
       a solver         gsf_nn_solver, in >>nn scheduler
   SECTIONS    files      >>nn kernels (types) >>nn numbers >>nn workspace >>nn files: safetensors, PyTorch, config.json
               lanes      >>nn vector
               kernels    >>nn activations >>nn norms >>nn linear >>nn int8 >>nn attention >>nn convolution >>nn positions
               layers     >>nn layers
               networks   >>nn image encoders >>nn bpe >>nn captioner >>nn tokenizer >>nn t5 >>nn vae >>nn transformer
               restoring  >>nn scheduler >>nn sampling >>nn restorer
               measuring  >>nn metrics
               training   >>nn training: gradients of layers and of the transformer, AdamW; with GSF_NN_TRAINING only
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

GSF_API size_t gsf_nn_get_dtype_size(gsf_nn_dtype dtype);  // bytes of one element

enum { GSF_NN_MAX_RANK = 8 };

typedef struct gsf_nn_tensor { // a view; owns nothing
    const char* name;
    const void* data;       // row-major; of ANY alignment in weight files
    gsf_nn_dtype dtype;
    int32_t rank;           // 0: one element
    int64_t shape[GSF_NN_MAX_RANK];
    int64_t count;          // product of the shape
} gsf_nn_tensor;

// Wraps the caller's float array as a tensor, to pass it as an argument.
GSF_API gsf_nn_tensor gsf_nn_wrap_tensor(const char* name, const float* data, int32_t rank, const int64_t* shape);

typedef struct gsf_nn_weights { // an open weight file or folder of them; tensors sorted by name
    char name[256];             // of the file or folder, for error messages
    gsf_nn_tensor* tensors;
    size_t tensor_count;
    uint64_t mapped_bytes;      // file-backed: the operating system may drop these pages at any time
    uint64_t read_bytes;        // held in memory: files that the platform or the io hook cannot map, copied tensors
    void* files;                // private
} gsf_nn_weights;

// Opens one weight file, or a folder: its *.safetensors.index.json with all shards, otherwise its only .safetensors file,
// otherwise its only .pth file. `prefix` (may be NULL) is the file name without suffix, for a folder that holds several
// models ("diffusion_pytorch_model"). Every length, offset, shape and dtype is checked: a malformed file gives
// GSF_ERROR_FORMAT with the file name and byte offset. BOOL is read as U8; other dtypes are unsupported. With the default
// io hook, files are mapped where the platform supports it: do not truncate an open file.
// safetensors: the tensors must cover the file's data exactly.
// PyTorch (.pth, .pt, .bin; told by content): zip and legacy containers, little-endian, uncompressed. The pickle is read as
// data: nothing is executed, and a global that state dictionaries do not need gives GSF_ERROR_UNSUPPORTED. Names of nested
// containers are joined by slashes ("optimizer/0/step"), without a first part that all tensors share ("state_dict/").
// Values other than tensors are skipped. Tensors that are not dense are copied, up to 8 times the file's size.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_weights(gsf_context* ctx, const char* path, const char* prefix,
                                                     gsf_nn_weights* out);
// The same for one file in memory; the caller keeps the bytes until the weights are destroyed.
GSF_API GSF_NODISCARD gsf_result gsf_nn_parse_weights(gsf_context* ctx, const char* name, const void* data,
                                                      size_t size, gsf_nn_weights* out);
GSF_API void gsf_nn_destroy_weights(gsf_context* ctx, gsf_nn_weights* weights);
GSF_API const gsf_nn_tensor* gsf_nn_find_tensor(const gsf_nn_weights* weights, const char* name); // NULL if absent
// Writes a safetensors file. Names must be unique; data is 8-byte aligned, as Hugging Face's safetensors writes it.
GSF_API GSF_NODISCARD gsf_result gsf_nn_save_tensors(gsf_context* ctx, const char* path, const gsf_nn_tensor* tensors,
                                                     size_t count);
// Converts `count` elements starting at `first` to float (f32, bf16, f16, f64 and the integers).
GSF_API void gsf_nn_convert_tensor(const gsf_nn_tensor* tensor, int64_t first, int64_t count, float* out);

// Private, for tests: called with every named intermediate of a network, (rows, columns) of sample `index`.
typedef struct gsf__nn_tap {
    void (*fn)(void* user, const char* name, int32_t index, const float* data, int64_t rows, int64_t columns);
    void* user;
} gsf__nn_tap;

// ---- image encoders for the reference photos ------------------------------------
// DINOv2 with registers and VGGT's aggregator turn photos into tokens, one per 14 x 14 patch, in row-major order.

typedef struct gsf_nn_dinov2 { // an open model; its weights stay in the mapped files
    int32_t width, heads, layers, mlp_width;
    int32_t channels, patch;     // of the images; side of a patch in pixels
    int32_t special;             // tokens that precede the patch tokens: the class token and the registers
    int32_t grid;                // patches along a side of the training images
    double norm_eps;
    gsf_nn_weights weights;
    void* nets;                  // private
} gsf_nn_dinov2;

// Opens a Hugging Face folder of Dinov2WithRegistersModel: config.json and model*.safetensors. The error names missing,
// misshaped and surplus tensors. The SwiGLU variant (use_swiglu_ffn) is unsupported.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_dinov2(gsf_context* ctx, const char* folder, gsf_nn_dinov2* out);
GSF_API void gsf_nn_destroy_dinov2(gsf_context* ctx, gsf_nn_dinov2* dinov2);

typedef struct gsf_nn_vggt { // an open aggregator; its weights stay in the mapped files
    int32_t width, heads, layers, mlp_width; // of its blocks; layers: pairs of a frame and a global block
    int32_t patch, embed_layers; // side of a patch in pixels; blocks of the DINOv2 that embeds the images
    int32_t special;             // patch_start_idx: the camera token and registers that precede the patch tokens
    int32_t grid;                // patches along a side of the images that the embedding was trained with
    double rope_base;            // of the rotary embedding of q and k; 0: none
    gsf_nn_weights weights;
    void* nets;                  // private
} gsf_nn_vggt;

// Opens a folder with model*.safetensors, or one .safetensors file. It uses the tensors aggregator.* under their
// released names and ignores all others. If the folder has a config.json, these keys of VGGT are read from it:
// embed_dim, depth, num_heads, patch_size, img_size, mlp_ratio, num_register_tokens, qk_norm and rope_freq. The rest
// is inferred from tensor shapes, except num_heads (width / 64 if q and k have no norms) and rope_freq (100).
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_vggt(gsf_context* ctx, const char* path, gsf_nn_vggt* out);
GSF_API void gsf_nn_destroy_vggt(gsf_context* ctx, gsf_nn_vggt* vggt);

typedef struct gsf_nn_encoder_desc {
    const float* pixels;           // (images, 3, height, width) in [0,1]
    int32_t images, height, width; // height and width in pixels, multiples of the patch size
    int32_t all_tokens;            // return the special tokens as well; 0: only the patch tokens
    const gsf__nn_tap* _tap;       // private
} gsf_nn_encoder_desc;

// The last hidden state after its norm: out (images, tokens, width), tokens = height/patch * width/patch, preceded by
// the `special` tokens if all_tokens is set. Images are not resized. Position embeddings are interpolated from the
// square grid as PyTorch does it (bicubic, antialiased, align_corners=False). A NaN or infinity gives GSF_ERROR_NUMERIC
// and the name of the layer. On error `out` is zeroed. Cancellation is checked and progress reported after every block.
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_dinov2(gsf_context* ctx, const gsf_nn_dinov2* dinov2,
                                                      const gsf_nn_encoder_desc* input, float* out);
// The outputs of the last pair of blocks: out (images, tokens, 2 width), frame block | global block. All images are
// encoded together and attend to one another. Normalises with ImageNet's mean and deviation. Otherwise as above.
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_vggt(gsf_context* ctx, const gsf_nn_vggt* vggt,
                                                    const gsf_nn_encoder_desc* input, float* out);

typedef struct gsf_nn_features { // of reference photos; zero-initialise, then destroy it
    int64_t images, tokens;               // tokens of each image
    int64_t dino_channels, vggt_channels; // 0: not computed
    float *dino, *vggt;                   // (images, tokens, channels)
} gsf_nn_features;

// Prepares the photos and encodes them with the models given. A later call with the other model adds its tokens, so
// only one model need be open at a time. All photos must have the same size after preparation. On error the tokens that
// the call would have computed are NULL.
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_references(gsf_context* ctx, const gsf_nn_dinov2* dinov2,
                                                          const gsf_nn_vggt* vggt, const gsf_image* photos, int32_t count,
                                                          gsf_nn_features* features);
GSF_API void gsf_nn_destroy_features(gsf_context* ctx, gsf_nn_features* features);

// ---- tokens: byte-level pair encoding -----------------------------------------------
// The tokenizer of GPT-2 and OPT, as in transformers 4.51.3 (GPT2Tokenizer).

typedef struct gsf_nn_bpe {     // an open tokenizer
    int32_t bos, eos, unk, pad; // ids, -1: none
    int32_t highest_id;
    int32_t add_bos;            // texts begin with `bos`
    void* tables;               // private
} gsf_nn_bpe;

// Opens FOLDER/vocab.json and merges.txt and, if present, tokenizer_config.json, special_tokens_map.json and
// added_tokens.json. Malformed content, or the name of an unknown token, gives GSF_ERROR_FORMAT with file and position.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_bpe(gsf_context* ctx, const char* folder, gsf_nn_bpe* out);
GSF_API void gsf_nn_destroy_bpe(gsf_context* ctx, gsf_nn_bpe* bpe);

// Encodes `size` bytes of text, which must be UTF-8; free *ids with gsf_free. `no_bos` omits the leading bos token even
// if add_bos is set. Takes O(n log n) time for any text. Any number of threads, each with its own context, may share a
// tokenizer.
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_bpe(gsf_context* ctx, const gsf_nn_bpe* bpe, const char* text, size_t size,
                                                   int32_t no_bos, int32_t** ids, size_t* count);
// Appends the text of `count` ids to `out`; the text may contain zero bytes. Invalid UTF-8 becomes U+FFFD. Ids without
// a token are skipped; `skip_special` also skips the special tokens (bos, eos, pad, <image> ...).
GSF_API GSF_NODISCARD gsf_result gsf_nn_decode_bpe(gsf_context* ctx, const gsf_nn_bpe* bpe, const int32_t* ids,
                                                   size_t count, int32_t skip_special, gsf_buffer* out);

// ---- captions ------------------------------------------------------------------------
// BLIP-2 with OPT (transformers 4.51.3, Blip2ForConditionalGeneration): a short caption for an image. The restorer's
// prompt begins with such a caption.

typedef struct gsf_nn_captioner { // an open model; its weights stay in the mapped files
    int32_t image_size;           // images are resized to a square of this side, whatever their aspect ratio
    int32_t query_tokens;         // tokens that represent the image in the language model's input
    int32_t vocabulary, positions; // of the language model: ids; maximum number of tokens, including the image's
    int32_t bos, eos;             // starts a caption without prompt; ends every caption
    int32_t image_token;          // "image_token_index"; -1: an older folder without it, with a shorter default length
    gsf_nn_bpe tokenizer;
    gsf_nn_weights weights;
    void* nets;                   // private
} gsf_nn_captioner;

// Opens a Hugging Face folder: config.json, preprocessor_config.json, the tokenizer's files (gsf_nn_load_bpe) and
// model*.safetensors in f32, bf16 or f16; it computes in float32. Absent keys get the defaults of transformers. The
// error names missing, misshaped and surplus tensors (GSF_ERROR_FORMAT) and unsupported settings
// (GSF_ERROR_UNSUPPORTED): a language model other than OPT, or norms after the layers (do_layer_norm_before false).
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_captioner(gsf_context* ctx, const char* folder, gsf_nn_captioner* out);
GSF_API void gsf_nn_destroy_captioner(gsf_context* ctx, gsf_nn_captioner* captioner);

// Captions an image (1, 3 or 4 channels, any dtype; alpha is ignored). The caption is zero-terminated UTF-8 without
// leading or trailing white space. With a prompt (may be NULL), the caption continues it and does not repeat it.
// Decoding is greedy and stops after `max_new_tokens` tokens; 0: 20 (older folders: 17, or 19 minus two per token of
// the prompt). Text that does not fit into `size` bytes is cut after a whole character; a zero byte in it becomes
// U+FFFD. A NaN or infinity in weights or between layers gives GSF_ERROR_NUMERIC and the name of the tensor or layer.
// Progress and cancellation after every layer. Any number of threads, each with its own context, may share a captioner.
GSF_API GSF_NODISCARD gsf_result gsf_nn_caption_image(gsf_context* ctx, const gsf_nn_captioner* captioner,
                                                      const gsf_image* image, const char* prompt,
                                                      int32_t max_new_tokens, char* out, size_t size);

// ---- text: tokenizer ------------------------------------------------------------------
// SentencePiece's unigram model as GSFixer's pipeline runs it: transformers 4.51.3 T5Tokenizer (slow, legacy) with
// sentencepiece 0.2.3. The ids match these versions exactly; other versions of sentencepiece round differently and may
// pick the other of two segmentations with equal score.

typedef struct gsf_nn_tokenizer { // self-contained and immutable: threads may share it
    int32_t piece_count;                // of spiece.model; their ids are 0 ... piece_count - 1
    int32_t id_count;                   // all ids, including those of added tokens, are smaller
    int32_t unknown_id, end_id, pad_id; // of <unk>, </s>, <pad>
    void* model;                        // private
} gsf_nn_tokenizer;

// Opens FOLDER/spiece.model. The added tokens (<extra_id_0> ...) come from FOLDER/tokenizer_config.json or, if that
// lists none, FOLDER/added_tokens.json; without either file they are T5's 100. Every length and offset is checked: a
// malformed file gives GSF_ERROR_FORMAT with its name and byte offset, a model other than unigram
// GSF_ERROR_UNSUPPORTED.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_tokenizer(gsf_context* ctx, const char* folder, gsf_nn_tokenizer* out);
GSF_API void gsf_nn_destroy_tokenizer(gsf_context* ctx, gsf_nn_tokenizer* tokenizer);

// Encodes `size` bytes of UTF-8 (zeros allowed; a malformed byte counts as U+FFFD); the last id is end_id. If there are
// more than `room` ids, `ids` gets the first room - 1 and end_id; if there are fewer, it is padded with pad_id. GSFixer
// uses a room of 226. *count (may be NULL) is the untruncated number of ids, including end_id. ids NULL with room 0
// only counts. Time and memory are proportional to the text: about 20 bytes per byte of text. Fails only when out of
// memory, or with GSF_ERROR_INVALID_ARGUMENT if the normalised text reaches 2 GiB.
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_text(gsf_context* ctx, const gsf_nn_tokenizer* tokenizer,
                                                    const char* text, size_t size, int32_t* ids, size_t room,
                                                    size_t* count);

// ---- text: T5 encoder -------------------------------------------------------------------
// The encoder of T5 v1.1 (Raffel et al. 2020; transformers 4.51.3 T5EncoderModel). As in GSFixer's pipeline there is no
// attention mask: padding is attended to like any other token. Every size is read from the folder's config.json.

typedef struct gsf_nn_t5 { // an open model; its weights stay in the mapped files. Threads may share it
    int32_t width, heads, head_dim, hidden, layers; // hidden: width of the feed-forward layers
    int32_t vocabulary;                             // all ids are smaller
    int32_t buckets, max_distance;                  // of the relative position bias
    double norm_eps;
    gsf_nn_weights weights;
    void* nets;                                     // private
} gsf_nn_t5;

// Opens FOLDER/config.json and FOLDER/model*.safetensors. The error names missing, misshaped and surplus tensors.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_t5(gsf_context* ctx, const char* folder, gsf_nn_t5* out);
GSF_API void gsf_nn_destroy_t5(gsf_context* ctx, gsf_nn_t5* t5);

typedef struct gsf_nn_t5_desc {
    const int32_t* ids; // (batch, tokens), from gsf_nn_encode_text
    int32_t batch, tokens; // each layer's weights are loaded once for all prompts of a batch
    const gsf__nn_tap* _tap; // private
} gsf_nn_t5_desc;

// The prompts' embeddings: out (batch, tokens, width). Layers run one after another, so of the mapped weights only one
// layer has to be in memory at a time. An id outside the vocabulary gives GSF_ERROR_INVALID_ARGUMENT. A NaN or infinity
// is reported with the block where it first appears (GSF_ERROR_NUMERIC). Can be cancelled between layers; progress
// "text".
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_t5(gsf_context* ctx, const gsf_nn_t5* t5, const gsf_nn_t5_desc* input,
                                                  float* out);
// ---- video autoencoder ----------------------------------------------------------
// AutoencoderKLCogVideoX as diffusers 0.32.1 runs it: clips are processed in chunks of 8 frames (encoder) or 2 latent
// frames (decoder), with the remainder added to the first chunk. Causal convolutions see the last two frames of the
// previous chunk; group norms compute their statistics per chunk. latents are (latent_channels, frames, height/8,
// width/8), unscaled.

enum { GSF_NN_VAE_LEVELS = 8 };

typedef struct gsf_nn_vae { // an open model; its weights stay in the mapped file
    int32_t in_channels, out_channels, latent_channels;
    int32_t levels, channels[GSF_NN_VAE_LEVELS]; // of the encoder's levels, finest first
    int32_t layers_per_block, norm_groups;
    int32_t spatial_ratio, temporal_ratio;       // pixels per latent pixel; frames per latent frame
    int32_t sample_height, sample_width;         // trained size in pixels; tiles are half of it
    double norm_eps, scaling_factor;             // the diffusion model sees latents * scaling_factor
    gsf_nn_weights weights;
    void* nets;                                  // private
} gsf_nn_vae;

// Opens a diffusers folder: config.json and diffusion_pytorch_model*.safetensors. A missing, misshaped or surplus
// tensor gives GSF_ERROR_FORMAT and its name.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_vae(gsf_context* ctx, const char* folder, gsf_nn_vae* out);
GSF_API void gsf_nn_destroy_vae(gsf_context* ctx, gsf_nn_vae* vae);

typedef struct gsf_nn_vae_desc {
    int32_t tiled;             // overlapping, linearly blended tiles: less memory, other values (statistics per tile)
    int32_t tile_height, tile_width;   // pixels, 0: half of sample_height, sample_width
    double overlap_height, overlap_width; // parts of a tile, 0: 1/6 and 1/5. Tile times overlap must be whole latents.
    double max_bytes;          // runs that need more fail with GSF_ERROR_OUT_OF_MEMORY before starting; 0: no limit
} gsf_nn_vae_desc;

typedef enum gsf_nn_vae_way { GSF_NN_VAE_ENCODE = 0, GSF_NN_VAE_DECODE } gsf_nn_vae_way;

typedef struct gsf_nn_vae_info {
    int64_t frames, height, width; // of the result. As in diffusers, 2 latent frames decode to 8 frames, 3 to 9
    int64_t chunks;                // number of progress steps
    double flops;                  // 2 per multiply-add of the convolutions that will be computed
    double bytes;                  // peak memory, excluding input, output and mapped weights
} gsf_nn_vae_info;

// Output size and cost of a run over `frames` x `height` x `width` (of the latents when decoding), without running it.
// `desc` may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_nn_query_vae(gsf_context* ctx, const gsf_nn_vae* vae, gsf_nn_vae_way way,
                                                  const gsf_nn_vae_desc* desc, int64_t frames, int64_t height,
                                                  int64_t width, gsf_nn_vae_info* out);

// video: (in_channels, frames, height, width) in [-1, 1], any size of at least 8 x 8. mean, logvar (or NULL):
// (latent_channels, info.frames, info.height, info.width); logvar is clamped to [-30, 20].
// A NaN or infinity gives GSF_ERROR_NUMERIC and the name of the layer where it appears. On error outputs are zeroed.
GSF_API GSF_NODISCARD gsf_result gsf_nn_encode_vae(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                                   const float* video, int64_t frames, int64_t height, int64_t width,
                                                   float* mean, float* logvar);
// latents: (latent_channels, frames, height, width); video: (out_channels, info.frames, info.height, info.width).
GSF_API GSF_NODISCARD gsf_result gsf_nn_decode_vae(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                                   const float* latents, int64_t frames, int64_t height, int64_t width,
                                                   float* video);

// ---- the restorer's transformer ----------------------------------------------------
// CogVideoX 5B I2V with cross-attention to reference tokens in every block (GSFixer, sec. 3.2). Every size is read from
// the folder's config.json.

typedef struct gsf_nn_transformer { // an open model; its weights stay in the mapped files
    int32_t heads, head_dim, layers;                        // width = heads * head_dim
    int32_t in_channels, out_channels;                      // of the latents: noisy and control concatenated; velocity
    int32_t text_channels, text_tokens, time_channels;
    int32_t dino_channels, vggt_channels;                   // of the two kinds of reference tokens
    int32_t patch;                                          // side of the square of latents that one token covers
    int32_t sample_width, sample_height, sample_frames;     // trained size: latents across and down, video frames
    int32_t temporal_ratio;                                 // video frames per latent frame
    int32_t attention_bias, learned_positions, rotary_positions;
    double spatial_scale, temporal_scale;                   // of the sine-cosine position embedding
    double norm_eps;
    gsf_nn_weights weights;
    int32_t bf16;                                           // the `bf16` member of its linear layers and attention;
                                                            // may be changed at any time
    void* nets;                                             // private
} gsf_nn_transformer;

// Opens FOLDER/config.json and FOLDER/diffusion_pytorch_model*.safetensors. The error names missing, misshaped and
// surplus tensors.
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_transformer(gsf_context* ctx, const char* folder, gsf_nn_transformer* out);
GSF_API void gsf_nn_destroy_transformer(gsf_context* ctx, gsf_nn_transformer* transformer);

// Switches the blocks' linear layers to 8-bit integers (gsf__nn_run_linear_int8). Allocates about one byte per weight
// (7.1 GB at the GSFixer release's size), returned in *bytes (may be NULL); the mapped originals are not used any more.
GSF_API GSF_NODISCARD gsf_result gsf_nn_quantize_transformer(gsf_context* ctx, gsf_nn_transformer* transformer,
                                                             size_t* bytes);

// Reference tokens for the cross-attention: the sum of both projections. dino (tokens, dino_channels), vggt (tokens,
// vggt_channels); either may be NULL to leave it out (the paper's ablation). out: (tokens, width).
GSF_API GSF_NODISCARD gsf_result gsf_nn_project_references(gsf_context* ctx, const gsf_nn_transformer* transformer,
                                                           int64_t tokens, const float* dino, const float* vggt,
                                                           float* out);

typedef struct gsf_nn_block_cache { // for gsf_nn_transformer_desc; zero it, set threshold, destroy it when done
    float threshold; // reuse the others' residuals if the first block's changes by less (relative L1); 0: never
    float *first, *before, *rest; // private: residuals of the first block and of all others
    size_t size;
    int64_t hits, calls;
} gsf_nn_block_cache;

GSF_API void gsf_nn_destroy_block_cache(gsf_context* ctx, gsf_nn_block_cache* cache);

typedef struct gsf_nn_transformer_desc {
    int32_t batch, frames, height, width; // of the latents
    const float* hidden;                  // (batch, frames, in_channels, height, width)
    const float* text;                    // (batch, text tokens, text_channels)
    int32_t text_tokens;                  // 0: the configured number
    const double* timesteps;              // (batch), 0 .. 999
    const float* references;              // (reference_batch, reference_tokens, width); NULL: no cross-attention
    int64_t reference_tokens;
    int32_t reference_batch;              // batch, or 1: shared by all rows of the batch
    int32_t no_rotary;                    // disable the rotary embedding even if it is configured
    gsf_nn_block_cache* cache;            // NULL: every block runs
    float* reference_kv;                  // the references' keys and values, gsf__nn_query_reference_kv floats;
                                          // NULL: recompute them in every call
    int32_t reference_kv_ready;           // reference_kv was filled by an earlier call
    const gsf__nn_tap* _tap;              // private
} gsf_nn_transformer_desc;

// Predicted velocity: out (batch, frames, out_channels, height, width). A NaN or infinity is reported with the block
// where it first appears (GSF_ERROR_NUMERIC). If the position table is learned, a height or width other than the
// configured one gives GSF_ERROR_UNSUPPORTED. For another number of frames (or text tokens) sine-cosine positions
// replace the table, as in diffusers; the model was not trained with them (see gsf_nn_sample_desc.any_frames).
GSF_API GSF_NODISCARD gsf_result gsf_nn_run_transformer(gsf_context* ctx, const gsf_nn_transformer* transformer,
                                                        const gsf_nn_transformer_desc* input, float* out);

// ---- noise schedule and solvers -------------------------------------------------
// x_t = sqrt(abar_t) x0 + sqrt(1 - abar_t) noise. The model predicts v = sqrt(abar) noise - sqrt(1 - abar) x0, so that
// x0 = sqrt(abar) x - sqrt(1 - abar) v. Coefficients are double, latents float32.

typedef enum gsf_nn_spacing { GSF_NN_SPACING_TRAILING = 0, GSF_NN_SPACING_LEADING,
                             GSF_NN_SPACING_LINSPACE } gsf_nn_spacing;

typedef struct gsf_nn_schedule_desc { // all zero: the values of CogVideoX-5B
    int32_t train_steps;           // 0: 1000
    double beta_start, beta_end;   // 0: 0.00085, 0.012
    int32_t linear_betas;          // 0: linear in sqrt(beta) ("scaled_linear")
    int32_t no_zero_snr;           // 0: rescale the table so that abar ends at 0
    int32_t no_alpha_one;          // 0: the last step goes to abar = 1, otherwise to abar of time step 0
    gsf_nn_spacing spacing;
    int32_t steps_offset;  // added to the time steps; GSF_NN_SPACING_LEADING only
    double snr_shift_scale;        // 0: 1; CogVideoX-2B was trained with 3
} gsf_nn_schedule_desc;

typedef struct gsf_nn_schedule {
    gsf_nn_schedule_desc desc; // with the defaults filled in
    double* alpha_bar;         // (train_steps), owned
    double final_alpha_bar;
} gsf_nn_schedule;

GSF_API GSF_NODISCARD gsf_result gsf_nn_make_schedule(gsf_context* ctx, const gsf_nn_schedule_desc* desc,
                                                      gsf_nn_schedule* out);
// Reads a scheduler_config.json; missing keys get the defaults of diffusers' DDIMScheduler. As in GSFixer's pipeline,
// the class name in the file is ignored. Anything but v-prediction, and clipping, is unsupported.
GSF_API GSF_NODISCARD gsf_result gsf_nn_parse_schedule(gsf_context* ctx, const char* name, const char* text, size_t size,
                                                       gsf_nn_schedule* out);
GSF_API GSF_NODISCARD gsf_result gsf_nn_load_schedule(gsf_context* ctx, const char* path, gsf_nn_schedule* out);
GSF_API void gsf_nn_destroy_schedule(gsf_context* ctx, gsf_nn_schedule* schedule);

typedef enum gsf_nn_solver {
    GSF_NN_SOLVER_DDIM = 0, // first order; the next time is t - train_steps/steps (integer division), as in diffusers
    GSF_NN_SOLVER_DPMPP_2M, // DPM-Solver++(2M): second order, keeps one earlier prediction (Lu et al. 2022b)
    GSF_NN_SOLVER_UNIPC, // UniPC, B2, order 2: adds a corrector that needs no further model call (Zhao et al. 2023)
} gsf_nn_solver;

typedef struct gsf_nn_sampler_desc {
    gsf_nn_solver solver;
    int32_t steps;      // 0: 50
    double strength;    // 0: 1
    size_t value_count; // of the latents
} gsf_nn_sampler_desc;

// The state of a solver. To resume from a checkpoint, make a sampler with the same desc and restore `index` and
// `memory` (and the latents); nothing else changes during a run.
typedef struct gsf_nn_sampler {
    gsf_nn_sampler_desc desc;
    const gsf_nn_schedule* schedule; // borrowed
    int32_t* timesteps;              // (count)
    int32_t count, index;            // the next model call is for timesteps[index]
    float* memory;                   // (memory_count): earlier predictions of the solver
    size_t memory_count;             // 0, 1 or 3 times value_count
} gsf_nn_sampler;

GSF_API GSF_NODISCARD gsf_result gsf_nn_make_sampler(gsf_context* ctx, const gsf_nn_schedule* schedule,
                                                     const gsf_nn_sampler_desc* desc, gsf_nn_sampler* out);
// Frees the time steps and earlier predictions; does not free the schedule.
GSF_API void gsf_nn_destroy_sampler(gsf_context* ctx, gsf_nn_sampler* sampler);
// One step: x (value_count), the latents at timesteps[index], is advanced to the next time step; v is the model's
// output for x. x0 (may be NULL) receives the predicted clean latents. eta is 0, so nothing is random. A latent that is
// NaN or infinite afterwards gives GSF_ERROR_NUMERIC with the number of the step.
GSF_API GSF_NODISCARD gsf_result gsf_nn_step_sampler(gsf_context* ctx, gsf_nn_sampler* sampler, const float* v, float* x,
                                                     float* x0);

// ---- sampling: from artifact-ridden frames to restored ones --------------------------

typedef struct gsf_nn_sample_desc {
    uint32_t _start_canary;
    int32_t frames, height, width;  // of the video; frames 1, 9, 17, ..., the counts that the VAE reproduces
    int32_t any_frames;             // allow other frame counts than the trained one if positions are learned: see
                                    // gsf_nn_run_transformer
    const float* control;           // (3, frames, height, width) in [-1,1]: the video to restore
    const float* text;              // (2, text tokens, text channels): negative prompt, prompt
    const float* references;        // (reference_tokens, width) from gsf_nn_project_references; NULL: none
    int64_t reference_tokens;
    int32_t steps;                  // default 50
    gsf_nn_solver solver;           // default DDIM
    float guidance;                 // classifier-free guidance; default 6; 1: none (half the cost)
    float guidance_begin, guidance_end; // fraction of the steps, in [0,1], that is guided; default 0 to 1
    int32_t dynamic_guidance;       // cosine ramp of the guidance, as in diffusers' CogVideoX (use_dynamic_cfg)
    float strength;                 // (0,1]: fraction of the noise schedule to run; default 1: start from pure noise
    float block_cache;              // gsf_nn_block_cache.threshold; default 0: off
    int32_t no_reference_cache;     // project the references' keys and values again in every step, to save memory
    uint64_t seed;
    const float* noise;             // (latent frames, latent channels, height/8, width/8); NULL: drawn from the seed
    double max_bytes;               // larger needs fail with GSF_ERROR_OUT_OF_MEMORY before starting; 0: no limit
    const char* checkpoint;         // file written after every step, and resumed from if the model, precision, settings
                                    // and inputs match; NULL: none
    const gsf__nn_tap* _tap;        // private
    uint32_t _end_canary;
} gsf_nn_sample_desc;

// Returns the desc with its defaults filled in.
GSF_API gsf_nn_sample_desc gsf_nn_resolve_sample_desc(const gsf_nn_sample_desc* desc);

typedef struct gsf_nn_sample_stats {
    int32_t steps, resumed_from;    // steps run in this call; index of the first of them
    int32_t network_rows;           // samples run through the transformer: 2 per guided step
    int64_t cached_steps;           // steps in which the block cache skipped blocks
} gsf_nn_sample_stats;

// The restored video (3, frames, height, width), roughly in [-1,1] but not clamped. stats may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_nn_sample(gsf_context* ctx, const gsf_nn_transformer* transformer,
                                               const gsf_nn_vae* vae, const gsf_nn_schedule* schedule,
                                               const gsf_nn_sample_desc* desc, float* out, gsf_nn_sample_stats* stats);

typedef struct gsf_nn_sample_info { double bytes,
                                   flops; } gsf_nn_sample_info; // peak anonymous memory; floating-point operations

// The cost of gsf_nn_sample, without running it; fails if gsf_nn_sample would refuse to start.
GSF_API GSF_NODISCARD gsf_result gsf_nn_query_sample(gsf_context* ctx, const gsf_nn_transformer* transformer,
                                                     const gsf_nn_vae* vae, const gsf_nn_sample_desc* desc,
                                                     gsf_nn_sample_info* out);

// ---- the restorer `dit` ---------------------------------------------------------------

typedef enum gsf_nn_condition { GSF_NN_CONDITION_BOTH = 0, GSF_NN_CONDITION_2D, GSF_NN_CONDITION_3D,
                               GSF_NN_CONDITION_NONE } gsf_nn_condition;

typedef struct gsf_nn_dit_desc {
    const char* model;       // folder as released: transformer/, vae/, scheduler/; for whatever `features` lacks, also
                             // dinov2/ and vggt/ (reference tokens), tokenizer/ and text_encoder/ (prompts)
    const char* features;    // NULL, or a safetensors file of precomputed features: see FEATURES below
    const char* caption;     // for all clips; NULL: the window's, or else blip2/ captions the first frame
    const char* save_features; // file to write all photos' and clips' features to, usable as `features`; NULL: none
    int32_t keep_saved;      // keep and use what this file already holds, to continue a run; 0: replace the file
    gsf_nn_condition condition; // which reference tokens condition the model (the paper's ablation)
    int32_t int8;            // gsf_nn_quantize_transformer
    int32_t bf16;            // gsf_nn_transformer.bf16
    gsf_nn_sample_desc sample;  // steps, solver, guidance, any_frames ...; sizes, pointers and seed are set per window
} gsf_nn_dit_desc;

/* The paper's restorer behind the interface of gsfixer.h. The strings of `desc` are copied.

   FRAMES      It requests clips as the model was trained: that many frames of that size, with the whole photo squashed
               into it (limits.frame_count, width, height, squash; 49 frames of 720 x 480 at the release). A frame that
               shows a photo's view is replaced by the photo, resized likewise with PIL's bicubic filter.
               sample.any_frames allows 9, 17, ... frames: sine-cosine positions then replace the learned ones, which
               diffusers does silently. With the tests' small model of random weights that alone changes the same clip's
               frames by 0.67 (relative L2). This shows that positions matter; the effect on the released model has not
               been measured.
   REFERENCES  A clip's references are the photos taken from its first and last frame's views, or the photos nearest to
               those cameras, with distances in units of the photos' own median distance to what they look at; without
               cameras, all photos. They are squashed to the model's size before encoding: 925 tokens each at the
               release, whatever their aspect ratio.
   FEATURES    Features missing from the file are encoded before a clip is restored: captioner, text encoder, DINOv2 and
               VGGT are opened, run and closed one after another. In a file, features are named by photo and clip, both
               counted from 0:
                   dino_latents.photo4     (1, tokens, channels)
                   vggt_latents.photo4,7   (2, tokens, channels): first and last photo, encoded together
                   prompt_embeds.clip12    (2, text tokens, text channels): negative prompt, prompt
               A file for a single clip may have dino_latents, vggt_latents (images, tokens, channels) and
               prompt_embeds, which apply to clip 0 only. A folder that will be needed but is missing is reported when
               the restorer is made; if the file has features but lacks those of some clip, the error comes at that clip
               and names them. */
// Progress: "clip" (0 of 1, at its start), then after each unit of work "caption", "text", "dinov2", "vggt",
// "vae encode", "transformer", "restore" (steps), "vae decode".
GSF_API GSF_NODISCARD gsf_result gsf_nn_make_dit(gsf_context* ctx, const gsf_nn_dit_desc* desc, gsf_restorer* out);
GSF_API void gsf_nn_destroy_dit(gsf_context* ctx, gsf_restorer* restorer);

// ---- metrics that need networks -------------------------------------------------------
/* One object measures one stream of frames, which are never held together: zero it, choose the kind and the folder with
   the weights, pass the frames in order, read `score` at any time, destroy it.

   WEIGHTS     The files as published, in one folder; for each name the first of NAME.safetensors, NAME.pth and NAME.pth.tar
               that exists.
                   LPIPS            alexnet-owt-7be5be79, vgg16-397923af or squeezenet1_1-b8a52dc0 (torchvision), and
                                    alex, vgg or squeeze (linear layers, version 0.1: lpips/weights/v0.1)
                   I2V subject      dino_vitbase16_pretrain
                   I2V background   the same, clip_vitb16_pretrain, open_clip_vitb16_pretrain, and ensemble_lora/ with
                                    adapter_model and adapter_config.json (DreamSim's dreamsim_ensemble_checkpoint)
                   motion           amt-s
   CONVENTIONS Reported LPIPS values follow one of two: images scaled to [-1,1], as the lpips package documents it and as
               gsplat's trainer uses AlexNet; or images in [0,1] taken as if they were in [-1,1] (`raw`), as 3DGS, GSFixer
               and gsplat's trainer use VGG16. The values of the two cannot be compared.
               I2V follows VBench with torchvision 0.17 or later: frames are resized with antialiasing. Motion needs frames
               of at least 113 x 113 pixels; of an even number of frames the last is not used. */

typedef enum gsf_nn_metric_kind {
    GSF_NN_METRIC_LPIPS_ALEX = 0, GSF_NN_METRIC_LPIPS_VGG, GSF_NN_METRIC_LPIPS_SQUEEZE, // Zhang et al. 2018; low is good
    GSF_NN_METRIC_I2V_SUBJECT, GSF_NN_METRIC_I2V_BACKGROUND, // VBench's I2V_SC and I2V_BC: consistency with an input image
    GSF_NN_METRIC_MOTION_SMOOTHNESS, // VBench's MS: every second frame against one interpolated from its neighbours
} gsf_nn_metric_kind;

typedef struct gsf_nn_metric { // zero it, set the first part, destroy it when done
    gsf_nn_metric_kind kind;
    const char* models;        // folder with the weights; needed until the first frame has been measured
    int32_t raw;               // LPIPS: leave the images in [0,1]
    // results
    double score;              // of all frames so far. LPIPS: the mean. I2V: 0 before the second frame; motion: before the
                               // third one
    double last;               // of the last frame. LPIPS: its distance. I2V: its similarity to the input image. Motion: the
                               // last mean difference to an interpolated frame, 0 to 255
    int64_t count;             // frames measured
    void* state;               // private
    const gsf__nn_tap* _tap;   // private
    const int32_t* _heads;     // private: attention heads of each network; NULL: as many as have 64 channels
} gsf_nn_metric;

// Measures the next frame, which has three channels. `reference`: for LPIPS its true image, of the same size; for I2V the
// input image, of any size, which only the first frame needs; for motion NULL. The first call opens the weights; frame NULL
// only does that. A missing or misshaped tensor gives GSF_ERROR_FORMAT and its name, a NaN or infinity GSF_ERROR_NUMERIC,
// frames that are too small for the network GSF_ERROR_DEGENERATE. On error `score` is as before.
GSF_API GSF_NODISCARD gsf_result gsf_nn_measure_frame(gsf_context* ctx, gsf_nn_metric* metric, const gsf_image* frame,
                                                      const gsf_image* reference);
GSF_API void gsf_nn_destroy_metric(gsf_context* ctx, gsf_nn_metric* metric);

#ifdef __cplusplus
}
#endif

#endif // GSF_NN_INCLUDED

// End of the API; what follows is the implementation.

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_NN_IMPLEMENTATION)
#define GSFIXER_NN_IMPLEMENTATION
#endif
#if defined(GSFIXER_NN_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#if !defined(GSF_NN_IMPLEMENTED) || defined(GSF__ISA)
#define GSF_NN_IMPLEMENTED

// When GSF__ISA is defined, this header includes itself for one of its GSF__KERNELS_... parts: see >>lanes of
// gsfixer.h.
#ifndef GSF__ISA

#include "gsfixer.h" // again, for its internals, in case it was included before without an implementation macro

GSF__BEGIN_IMPLEMENTATION

// ---- >>nn kernels: their data types ---------------------------------------------
// The functions are described in their own sections. All pointers are to float32 and 4-byte aligned; outputs must not
// overlap inputs unless a comment allows it.

typedef struct gsf__nn_workspace { // scratch memory of kernels; zero-initialise; grows on demand and is reused
    void* memory;
    size_t size;
} gsf__nn_workspace;

// GELU is x/2 (1 + erf(x / sqrt 2)), with a relative error below 1e-6 for all x; GELU_TANH is its usual approximation,
// QUICK_GELU, x / (1 + exp(-1.702 x)), that of CLIP.
typedef enum gsf__nn_activation {
    GSF__NN_LINEAR = 0, GSF__NN_GELU_TANH, GSF__NN_SILU, GSF__NN_GELU, GSF__NN_RELU, GSF__NN_QUICK_GELU,
} gsf__nn_activation;

enum { GSF__NN_ACTIVATION_COUNT = GSF__NN_QUICK_GELU + 1 }; // tests loop over all of them

typedef struct gsf__nn_linear_desc {
    const float* x;            // (rows, in), row stride ldx
    int64_t rows, ldx;         // ldx 0: in
    const gsf_nn_tensor* weight; // (out, in); f32, bf16 or f16. Higher ranks: (out, product of the other dimensions)
    const gsf_nn_tensor* bias; // (out) or NULL
    gsf__nn_activation activation;
    const float* gate;         // (out) or NULL: y += gate * activation(x w^T + b) instead of y = ...
    int32_t accumulate;        // y += activation(x w^T + b) instead of y = ...
    float* y;                  // (rows, out), row stride ldy
    int64_t ldy;               // 0: out
    int32_t bf16;              // for bf16 weights, GSF_CPU_AVX512_BF16, more than 4 rows: also rounds x to bf16, sums
                               // products in pairs (relative L2 error 1.7e-3). Otherwise no effect
} gsf__nn_linear_desc;

typedef struct gsf__nn_quantized { // an 8-bit weight matrix; owns its memory: destroy it
    int64_t out, in;
    int32_t block;             // size of the rotated blocks of values: a power of two up to 256; 1: no rotation
    int8_t* data;              // private: whole tiles, [out/16][in/4][16][4]
    float* scales;             // private: per output
    int32_t* offsets;          // private: 128 times the sum of each output's weights
    size_t bytes;              // size of all three: about out*in
} gsf__nn_quantized;

typedef struct gsf__nn_attention_desc {
    int64_t queries, keys;     // rows of q and out; of k and v
    int32_t heads, head_dim;   // head h occupies columns h*head_dim ...
    const float *q, *k, *v;
    int64_t ldq, ldk, ldv;     // row strides, 0: heads*head_dim
    const unsigned char* mask; // (heads, queries, keys), 1 = may attend; NULL = all. A row of zeros gives 0.
    const float* bias;         // (heads, queries, keys), added to the logits, unscaled; NULL = none
    float scale;               // of the logits, 0: 1/sqrt(head_dim)
    float* out;                // (queries, heads*head_dim), row stride ldo; may be q
    int64_t ldo;
    float* lse;                // NULL, or (heads, queries): what gsf__nn_attention_grad needs to recompute the weights
    int32_t bf16;              // GSF_CPU_AVX512_BF16, even head_dim: rounds q, k, v and the softmax weights to bf16
} gsf__nn_attention_desc;

// ---- convolution ----
// Activations of convolutions are channels-last: (frames, height, width, channels).

typedef struct gsf__nn_conv_desc {
    const float* x;            // (frames, height, width, in)
    int64_t frames, height, width;
    const gsf_nn_tensor* weight; // (out, in, kh, kw): per frame; (out, in, kt, kh, kw), kt 1 or 3: causal in time.
                               // kh = kw is 1 or 3; f32, bf16 or f16
    const gsf_nn_tensor* bias; // (out) or NULL
    const float* before;       // (2, height, width, in): the frames before x; NULL: x's first frame, twice. kt = 3 only
    int32_t halve;             // stride 2, padded by one row of zeros below and one column to the right;
                               // 0: stride 1, padded on all four sides
    int32_t accumulate;        // y += instead of y = ...
    float* y;                  // (frames, height, width, out); halve: (frames, height/2, width/2, out), rounded down
} gsf__nn_conv_desc;

// ---- positions ----
// Tables for the video transformer. Tokens are ordered by frame, row, column.

typedef struct gsf__nn_rope_desc {
    int32_t frames, height, width;   // of the grid of tokens: latent frames, latent height and width / patch size
    int32_t base_height, base_width; // the grid the model was trained with: sample_height, sample_width / patch size
    int32_t head_dim;                // a multiple of 16: time gets head_dim/4 of it, rows and columns 3*head_dim/8 each
    double theta;                    // 0: 10000
} gsf__nn_rope_desc;

// ---- >>nn numbers ---------------------------------------------------------------

static int64_t gsf__least(int64_t a, int64_t b) { return a < b ? a : b; }
static int64_t gsf__ceil_div(int64_t a, int64_t b) { return (a + b - 1) / b; }
static int64_t gsf__round_up(int64_t a, int64_t b) { return gsf__ceil_div(a, b) * b; }

static float gsf__bf16_to_float(uint16_t value) {
    const uint32_t bits = (uint32_t)value << 16;
    float out;
    memcpy(&out, &bits, sizeof out);
    return out;
}

// Round to nearest, ties to even; a NaN remains a NaN.
GSF__SHARED uint16_t gsf__float_to_bf16(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    if ((bits & 0x7fffffffu) > 0x7f800000u) return (uint16_t)(bits >> 16 | 0x40u);
    return (uint16_t)((bits + 0x7fffu + (bits >> 16 & 1u)) >> 16);
}

GSF_API size_t gsf_nn_get_dtype_size(gsf_nn_dtype dtype) {
    switch (dtype) {
        case GSF_NN_F32: case GSF_NN_I32: return 4;
        case GSF_NN_BF16: case GSF_NN_F16: case GSF_NN_I16: return 2;
        case GSF_NN_F64: case GSF_NN_I64: return 8;
        case GSF_NN_U8: case GSF_NN_I8: return 1;
    }
    return 0;
}

// safetensors' name for it: "BF16"
static const char* gsf__nn_dtype_name(gsf_nn_dtype dtype) {
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

GSF_API gsf_nn_tensor gsf_nn_wrap_tensor(const char* name, const float* data, int32_t rank, const int64_t* shape) {
    gsf_nn_tensor tensor;
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

GSF_API void gsf_nn_convert_tensor(const gsf_nn_tensor* tensor, int64_t first, int64_t count, float* out) {
    const char* p = (const char*)tensor->data + (size_t)first * gsf_nn_get_dtype_size(tensor->dtype);
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

static void gsf__nn_destroy_workspace(gsf_context* ctx, gsf__nn_workspace* workspace) {
    gsf_free(ctx, workspace->memory);
    memset(workspace, 0, sizeof *workspace);
}

// Returns at least `size` bytes, discarding the workspace's previous contents. NULL when out of memory.
static void* gsf__nn_scratch(gsf_context* ctx, gsf__nn_workspace* workspace, size_t size) {
    if (size <= workspace->size) return workspace->memory;
    gsf__nn_destroy_workspace(ctx, workspace);
    workspace->memory = gsf_alloc(ctx, size, 1);
    workspace->size = workspace->memory ? size : 0;
    return workspace->memory;
}

// ---- >>nn files -----------------------------------------------------------------

/* A safetensors file:
       u64 n (little-endian) | n bytes of JSON, padded with spaces | data
       {"__metadata__": {"key": "text", ...}, "name": {"dtype": "BF16", "shape": [2, 3], "data_offsets": [begin, end]}, ...}
   Offsets are relative to the first byte of the data. As in Hugging Face's reader, the tensors must cover the data
   without holes, overlap or trailing bytes.
   (github.com/huggingface/safetensors, README and safetensors/src/tensor.rs) */

enum { GSF__NN_FILE_HEAD = 8, GSF__NN_HEADER_MAX = 100000000 }; // bytes; the limit is that of Hugging Face's reader

typedef enum gsf__nn_holder { GSF__NN_BORROWED, GSF__NN_READ, GSF__NN_MAPPED } gsf__nn_holder;

typedef struct gsf__nn_file {
    const unsigned char* data;
    size_t size;
    gsf__nn_holder holder;
    char* names; // of its tensors, zero-terminated, one after the other
    size_t names_size;
    unsigned char* copies; // of the tensors of a PyTorch file that are not dense there; or NULL
} gsf__nn_file;

typedef struct gsf__nn_files {
    gsf__nn_file* files;
    size_t count, capacity, tensor_capacity;
} gsf__nn_files;

// ---- platform: the kind of a path, listing a folder, mapping a file

typedef enum gsf__nn_path_kind { GSF__NN_UNKNOWN, GSF__NN_IS_FILE, GSF__NN_IS_FOLDER } gsf__nn_path_kind;

// The name of the only file in `folder` that ends in `suffix`; empty if there is none. More than one is an error.
typedef struct gsf__nn_listing {
    const char *folder, *suffix;
    gsf_buffer found;
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
    if (!folder) return gsf_fail(ctx, gsf__open_result(errno), "%s: %s", listing->folder, strerror(errno));
    gsf_result result = GSF_OK;
    for (const struct dirent* entry; result == GSF_OK && (entry = readdir(folder)) != NULL;) {
        if (entry->d_name[0] == '.' || !gsf__nn_ends_in(entry->d_name, listing->suffix)) continue;
        if (listing->found.size) {
            result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: contains both %s and %s: pass a prefix",
                              listing->folder, listing->found.data, entry->d_name);
        } else {
            gsf_append_bytes(ctx, &listing->found, entry->d_name, strlen(entry->d_name));
            if (listing->found.failed) result = GSF_ERROR_OUT_OF_MEMORY;
        }
    }
    closedir(folder);
    return result;
}

// *data is NULL if the file cannot be mapped; it may still be readable.
static gsf_result gsf__nn_map(gsf_context* ctx, const char* path, const unsigned char** data, size_t* size) {
    struct stat info;
    *data = NULL;
    *size = 0;
    const int file = open(path, O_RDONLY | O_NONBLOCK); // do not block on a pipe
    if (file < 0) return gsf_fail(ctx, gsf__open_result(errno), "%s: %s", path, strerror(errno));
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

// FOLDER/NAME; the caller frees `out`, also on error.
static gsf_result gsf__nn_join(gsf_context* ctx, const char* folder, const char* name, gsf_buffer* out) {
    memset(out, 0, sizeof *out);
    gsf_append_text(ctx, out, "%s%s%s", folder, gsf__nn_ends_in(folder, "/") ? "" : "/", name);
    return out->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

// ---- reading the header

// A name made safe for a one-line message: ASCII, truncated.
typedef struct gsf__nn_shown { char text[100]; } gsf__nn_shown;

static gsf__nn_shown gsf__nn_show(const char* name) {
    gsf__nn_shown shown;
    snprintf(shown.text, sizeof shown.text, "%.99s", name);
    for (char* c = shown.text; *c; c++)
        if (*c < 0x20 || *c > 0x7e) *c = '?';
    return shown;
}

// The end of a path that fits into a document's name (gsf_json).
static const char* gsf__nn_path_end(const char* path) {
    const size_t size = strlen(path), room = sizeof ((gsf_json*)0)->name - 1;
    return size > room ? path + (size - room) : path;
}

// Parses a non-negative integer written without sign, fraction or exponent, up to 2^63 - 1. Returns 0 if it is none.
static int gsf__nn_read_size(const char* text, const gsf_json_value* value, uint64_t* out) {
    *out = 0;
    if (value->type != GSF_JSON_NUMBER) return 0;
    const char* p = text + value->offset; // cannot overrun: in a checked document a non-digit follows
    if (*p == '-') return 0;
    for (; *p >= '0' && *p <= '9'; p++) {
        if (*out > ((uint64_t)INT64_MAX - (uint64_t)(*p - '0')) / 10) return 0;
        *out = *out * 10 + (uint64_t)(*p - '0');
    }
    return *p != '.' && *p != 'e' && *p != 'E';
}

typedef struct gsf__nn_header { // the header of one file while it is being read
    gsf_context* ctx;
    const char* name;
    const char* text;       // first byte of the file
    const char* data;       // first byte after the header
    uint64_t data_size;
    gsf_json json;
} gsf__nn_header;

static gsf_result gsf__nn_entry_fail(const gsf__nn_header* h, const gsf_json_value* at, const gsf_json_value* entry,
                                     gsf_result result, const char* text) {
    return gsf_fail(h->ctx, result, "%s:%u: tensor %s: %s", h->name, (unsigned)at->offset, gsf__nn_show(entry->key).text,
                    text);
}

static gsf_result gsf__nn_read_dtype(const gsf__nn_header* h, const gsf_json_value* entry, gsf_nn_tensor* out) {
    const gsf_json_value* value = gsf_find_json_member(&h->json, entry, "dtype");
    if (!value || value->type != GSF_JSON_STRING)
        return gsf__nn_entry_fail(h, value ? value : entry, entry, GSF_ERROR_FORMAT, "\"dtype\" is not a string");
    for (int i = GSF_NN_F32; i <= GSF_NN_I64; i++) {
        out->dtype = (gsf_nn_dtype)i;
        if (strcmp(value->string, gsf__nn_dtype_name(out->dtype)) == 0) return GSF_OK;
    }
    out->dtype = GSF_NN_U8;
    if (strcmp(value->string, "BOOL") == 0) return GSF_OK;
    char text[140];
    snprintf(text, sizeof text, "dtype %.30s is not supported", gsf__nn_show(value->string).text);
    return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_UNSUPPORTED, text);
}

static gsf_result gsf__nn_read_shape(const gsf__nn_header* h, const gsf_json_value* entry, gsf_nn_tensor* out) {
    const gsf_json_value* value = gsf_find_json_member(&h->json, entry, "shape");
    if (!value || value->type != GSF_JSON_ARRAY)
        return gsf__nn_entry_fail(h, value ? value : entry, entry, GSF_ERROR_FORMAT, "\"shape\" is not a list");
    if (value->count > GSF_NN_MAX_RANK)
        return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_UNSUPPORTED, "more than 8 dimensions");
    uint64_t count = 1, size;
    for (uint32_t i = value->child; i; i = h->json.values[i].next) {
        if (!gsf__nn_read_size(h->text, &h->json.values[i], &size))
            return gsf__nn_entry_fail(h, &h->json.values[i], entry, GSF_ERROR_FORMAT,
                                      "a dimension is not a non-negative integer");
        if (size != 0 && count > (uint64_t)INT64_MAX / size)
            return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_FORMAT, "the shape overflows");
        count *= size;
        out->shape[out->rank++] = (int64_t)size;
    }
    out->count = (int64_t)count;
    return GSF_OK;
}

static gsf_result gsf__nn_read_place(const gsf__nn_header* h, const gsf_json_value* entry, gsf_nn_tensor* out) {
    const gsf_json_value* value = gsf_find_json_member(&h->json, entry, "data_offsets");
    uint64_t begin, end;
    if (!value || value->type != GSF_JSON_ARRAY || value->count != 2 ||
        !gsf__nn_read_size(h->text, gsf_find_json_element(&h->json, value, 0), &begin) ||
        !gsf__nn_read_size(h->text, gsf_find_json_element(&h->json, value, 1), &end))
        return gsf__nn_entry_fail(h, value ? value : entry, entry, GSF_ERROR_FORMAT,
                                  "\"data_offsets\" is not a list of two non-negative integers");
    char text[160];
    if (begin > end || end > h->data_size) {
        snprintf(text, sizeof text, "bytes %llu to %llu are outside the %llu bytes of data", (unsigned long long)begin,
                 (unsigned long long)end, (unsigned long long)h->data_size);
        return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_FORMAT, text);
    }
    const uint64_t size = gsf_nn_get_dtype_size(out->dtype), count = (uint64_t)out->count;
    if (count > UINT64_MAX / size || count * size != end - begin) {
        snprintf(text, sizeof text, "%llu bytes for %llu values of %s", (unsigned long long)(end - begin),
                 (unsigned long long)count, gsf__nn_dtype_name(out->dtype));
        return gsf__nn_entry_fail(h, value, entry, GSF_ERROR_FORMAT, text);
    }
    out->data = h->data + begin;
    return GSF_OK;
}

static gsf_result gsf__nn_read_entry(const gsf__nn_header* h, const gsf_json_value* entry, gsf_nn_tensor* out) {
    memset(out, 0, sizeof *out);
    if (entry->type != GSF_JSON_OBJECT) return gsf__nn_entry_fail(h, entry, entry, GSF_ERROR_FORMAT, "not an object");
    if (strlen(entry->key) != entry->key_size)
        return gsf__nn_entry_fail(h, entry, entry, GSF_ERROR_FORMAT, "its name contains a zero byte");
    GSF__TRY(gsf__nn_read_dtype(h, entry, out));
    GSF__TRY(gsf__nn_read_shape(h, entry, out));
    return gsf__nn_read_place(h, entry, out);
}

static gsf_result gsf__nn_check_metadata(const gsf__nn_header* h, const gsf_json_value* metadata) {
    int ok = metadata->type == GSF_JSON_OBJECT;
    for (uint32_t i = metadata->child; ok && i; i = h->json.values[i].next)
        ok = h->json.values[i].type == GSF_JSON_STRING;
    return ok ? GSF_OK : gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%u: __metadata__ does not map strings to strings", h->name,
                                  (unsigned)metadata->offset);
}

static uint64_t gsf__nn_bytes(const gsf_nn_tensor* tensor) {
    return (uint64_t)tensor->count * gsf_nn_get_dtype_size(tensor->dtype);
}

static int gsf__nn_compare_places(const void* a, const void* b) { // empty tensors first where places tie
    const gsf_nn_tensor *x = (const gsf_nn_tensor*)a, *y = (const gsf_nn_tensor*)b;
    if (x->data != y->data) return (const char*)x->data < (const char*)y->data ? -1 : 1;
    return gsf__nn_bytes(x) < gsf__nn_bytes(y) ? -1 : gsf__nn_bytes(x) > gsf__nn_bytes(y);
}

static int gsf__nn_compare_names(const void* a, const void* b) {
    return strcmp(((const gsf_nn_tensor*)a)->name, ((const gsf_nn_tensor*)b)->name);
}

static gsf_result gsf__nn_check_cover(const gsf__nn_header* h, gsf_nn_tensor* tensors, size_t count) {
    const char* next = h->data;
    const char* const end = h->data + h->data_size;
    if (count) qsort(tensors, count, sizeof *tensors, gsf__nn_compare_places);
    for (size_t i = 0; i < count; i++) {
        const char* begin = (const char*)tensors[i].data;
        if (begin != next)
            return gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%zu: tensor %s %s", h->name, (size_t)(begin - h->text),
                            gsf__nn_show(tensors[i].name).text,
                            begin < next ? "overlaps the one before it" : "follows bytes that belong to no tensor");
        next = begin + gsf__nn_bytes(&tensors[i]);
    }
    if (next != end)
        return gsf_fail(h->ctx, GSF_ERROR_FORMAT, "%s:%zu: %zu bytes belong to no tensor", h->name,
                        (size_t)(next - h->text), (size_t)(end - next));
    return GSF_OK;
}

// Adds the tensors of a parsed header, which begins with '{' and so is an object. Copies their names to file->names.
static gsf_result gsf__nn_read_entries(gsf__nn_header* h, gsf_nn_weights* weights, gsf__nn_file* file) {
    gsf__nn_files* files = (gsf__nn_files*)weights->files;
    const gsf_json_value* root = &h->json.values[0];
    const size_t first = weights->tensor_count;
    size_t names = 1; // 1 so that the block is never empty
    for (uint32_t i = root->child; i; i = h->json.values[i].next) names += h->json.values[i].key_size + 1;
    file->names = (char*)gsf_alloc(h->ctx, names, 1);
    if (!file->names) return GSF_ERROR_OUT_OF_MEMORY;
    GSF__TRY(gsf__reserve(h->ctx, (void**)&weights->tensors, &files->tensor_capacity, first, first + root->count + 1,
                          sizeof *weights->tensors)); // + 1 so that the array is never empty
    for (uint32_t i = root->child; i; i = h->json.values[i].next) {
        const gsf_json_value* entry = &h->json.values[i];
        if (entry->key_size == 12 && memcmp(entry->key, "__metadata__", 12) == 0) {
            GSF__TRY(gsf__nn_check_metadata(h, entry));
            continue;
        }
        gsf_nn_tensor* tensor = &weights->tensors[weights->tensor_count];
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
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: %zu bytes are not a safetensors file", h.name, file->size);
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

// ---- reading a PyTorch file

/* torch.save puts a pickle, the byte code of a stack machine that builds Python objects, into one of two containers:
       zip     TOP/data.pkl | TOP/byteorder | TOP/data/KEY, one per storage; entries are stored, TOP is any name
       legacy  (before PyTorch 1.6) five pickles: magic number, 1001, platform, objects, list of keys | for each key of
               the list: u64 number of elements, elements
   A state dictionary maps names to _rebuild_tensor_v2(storage, offset, size, stride, ...); the pickle refers to a storage
   by the persistent id ("storage", torch.FloatStorage, KEY, location, number of elements).
   The pickle is read as data. Of all globals only those of gsf__pth_globals are accepted, and what they would do is done
   here; every other global, and every opcode that would make an instance, is an error. Each opcode makes at most one node
   and one member, so memory is proportional to the pickle; nothing recurses.
   (Python: Lib/pickletools.py; PyTorch: torch/serialization.py, torch/_weights_only_unpickler.py) */

typedef enum gsf__pth_kind {
    GSF__PTH_OTHER = 0, // a value that no tensor needs: None, a float, bytes, a set ...
    GSF__PTH_MARK, GSF__PTH_NUMBER, GSF__PTH_TEXT, GSF__PTH_SEQUENCE, GSF__PTH_DICT, GSF__PTH_GLOBAL, GSF__PTH_STORAGE,
    GSF__PTH_TENSOR,
} gsf__pth_kind;

typedef struct gsf__pth_node {
    gsf__pth_kind kind;
    uint32_t first, last, count; // of a container: its members; 0: none
    int32_t walked;              // of a container: the last walk that entered it
    int64_t value;               // number; offset of a text (count: its bytes); index of a global or storage; arguments of
                                 // a tensor (a node)
} gsf__pth_node;

typedef struct gsf__pth_member { uint32_t key, value, next; } gsf__pth_member; // nodes; next member, 0: none

typedef struct gsf__pth_storage {
    const char* key;
    uint32_t key_size;
    gsf_nn_dtype dtype;
    int64_t count;             // elements
    const unsigned char* data; // NULL: not found yet
} gsf__pth_storage;

typedef struct gsf__pth_entry { // of the zip container
    const char* name;
    size_t name_size, at, size; // offset in the file and bytes of the contents
    unsigned flags, method;
} gsf__pth_entry;

typedef struct gsf__pth_frame { // a container being walked
    uint32_t member, index; // the next one
    int64_t path_size;      // of the container's own name
} gsf__pth_frame;

enum { GSF__PTH_NAME_MAX = 256 };

typedef struct gsf__pth { // a file while it is being read
    gsf_context* ctx;
    const char* name;
    const unsigned char* data;
    size_t size;
    size_t at, end, opcode; // the pickle: next byte, end, current opcode
    gsf__pth_node* nodes;   // nodes[0] and members[0] are unused
    gsf__pth_member* members;
    uint32_t *stack, *memo; // nodes; memo: 0: not set
    gsf__pth_storage* storages;
    gsf__pth_entry* entries; // sorted by name
    gsf__pth_frame* frames;
    size_t node_count, node_room, member_count, member_room, depth, stack_room, memo_count, memo_room;
    size_t storage_count, storage_room, entry_count, frame_count, frame_room;
    char top[GSF__PTH_NAME_MAX]; // folder of the zip container, with its slash
    int zip;
    char path[GSF__PTH_NAME_MAX + 1];
    int32_t walk;
    size_t tensor_count, names_size, copies_size; // found by a walk
} gsf__pth;

GSF_PRINTF(4, 5)
static gsf_result gsf__pth_fail(const gsf__pth* p, gsf_result result, size_t at, const char* format, ...) {
    char text[300];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    return gsf_fail(p->ctx, result, "%s:%zu: %s", p->name, at, text);
}

static gsf_result gsf__pth_bad(const gsf__pth* p, const char* what) { // at the current opcode
    return gsf__pth_fail(p, GSF_ERROR_FORMAT, p->opcode, "pickle: %s", what);
}

// ---- PyTorch files: objects of the pickle

typedef enum gsf__pth_role {
    GSF__PTH_IGNORED, GSF__PTH_ORDERED_DICT, GSF__PTH_REBUILD, GSF__PTH_PARAMETER, GSF__PTH_SIZE, GSF__PTH_STORAGE_TYPE,
} gsf__pth_role;

static const struct gsf__pth_global {
    const char *module, *name;
    gsf__pth_role role;
    gsf_nn_dtype dtype; // of a storage
} gsf__pth_globals[] = {
    {"collections", "OrderedDict", GSF__PTH_ORDERED_DICT, GSF_NN_F32},
    {"torch._utils", "_rebuild_tensor_v2", GSF__PTH_REBUILD, GSF_NN_F32},
    {"torch._utils", "_rebuild_tensor", GSF__PTH_REBUILD, GSF_NN_F32},
    {"torch._utils", "_rebuild_parameter", GSF__PTH_PARAMETER, GSF_NN_F32},
    {"torch", "Size", GSF__PTH_SIZE, GSF_NN_F32},
    {"torch", "device", GSF__PTH_IGNORED, GSF_NN_F32},
    {"torch", "FloatStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_F32},
    {"torch", "DoubleStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_F64},
    {"torch", "HalfStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_F16},
    {"torch", "BFloat16Storage", GSF__PTH_STORAGE_TYPE, GSF_NN_BF16},
    {"torch", "LongStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_I64},
    {"torch", "IntStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_I32},
    {"torch", "ShortStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_I16},
    {"torch", "CharStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_I8},
    {"torch", "ByteStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_U8},
    {"torch", "BoolStorage", GSF__PTH_STORAGE_TYPE, GSF_NN_U8},
};

static gsf_result gsf__pth_push(gsf__pth* p, uint32_t node) {
    GSF__TRY(gsf__reserve(p->ctx, (void**)&p->stack, &p->stack_room, p->depth, p->depth + 1, sizeof *p->stack));
    p->stack[p->depth++] = node;
    return GSF_OK;
}

// Makes a node and pushes it.
static gsf_result gsf__pth_make(gsf__pth* p, gsf__pth_kind kind, int64_t value, uint32_t count) {
    if (p->node_count >= UINT32_MAX / 2) return gsf__pth_bad(p, "too many objects");
    GSF__TRY(gsf__reserve(p->ctx, (void**)&p->nodes, &p->node_room, p->node_count, p->node_count + 1, sizeof *p->nodes));
    gsf__pth_node* node = &p->nodes[p->node_count];
    memset(node, 0, sizeof *node);
    node->kind = kind;
    node->value = value;
    node->count = count;
    return gsf__pth_push(p, (uint32_t)p->node_count++);
}

static gsf_result gsf__pth_pop(gsf__pth* p, gsf__pth_kind kind, uint32_t* out) {
    *out = p->depth ? p->stack[p->depth - 1] : 0;
    if (!p->depth) return gsf__pth_bad(p, "nothing on the stack");
    if (kind != GSF__PTH_OTHER && p->nodes[*out].kind != kind) return gsf__pth_bad(p, "a value of the wrong type");
    if (kind != GSF__PTH_MARK && p->nodes[*out].kind == GSF__PTH_MARK) return gsf__pth_bad(p, "nothing above the mark");
    p->depth--;
    return GSF_OK;
}

static gsf_result gsf__pth_add(gsf__pth* p, uint32_t container, uint32_t key, uint32_t value) {
    gsf__pth_node* to = &p->nodes[container];
    if (p->member_count >= UINT32_MAX / 2) return gsf__pth_bad(p, "too many objects");
    GSF__TRY(gsf__reserve(p->ctx, (void**)&p->members, &p->member_room, p->member_count, p->member_count + 1,
                          sizeof *p->members));
    const uint32_t index = (uint32_t)p->member_count++;
    p->members[index].key = key;
    p->members[index].value = value;
    p->members[index].next = 0;
    if (to->last) p->members[to->last].next = index;
    else to->first = index;
    to->last = index;
    to->count++;
    return GSF_OK;
}

// The nodes above the topmost mark become members of `container`, which for a dictionary is given in pairs; all of them and
// the mark are popped.
static gsf_result gsf__pth_gather(gsf__pth* p, size_t mark, uint32_t container, int pairs) {
    if (pairs && (p->depth - mark) % 2 == 0) return gsf__pth_bad(p, "a key without a value");
    for (size_t i = mark + 1; i < p->depth; i += pairs ? 2 : 1)
        GSF__TRY(gsf__pth_add(p, container, pairs ? p->stack[i] : 0, p->stack[pairs ? i + 1 : i]));
    p->depth = mark;
    return GSF_OK;
}

static gsf_result gsf__pth_find_mark(gsf__pth* p, size_t* out) {
    *out = 0;
    for (size_t i = p->depth; i-- > 0;)
        if (p->nodes[p->stack[i]].kind == GSF__PTH_MARK) {
            *out = i;
            return GSF_OK;
        }
    return gsf__pth_bad(p, "no mark on the stack");
}

// Replaces the nodes from the mark on (or the topmost `count`, if not negative) by a container of them.
static gsf_result gsf__pth_collect(gsf__pth* p, gsf__pth_kind kind, int count) {
    size_t mark;
    if (count < 0) GSF__TRY(gsf__pth_find_mark(p, &mark));
    else if (p->depth < (size_t)count) return gsf__pth_bad(p, "nothing on the stack");
    else mark = p->depth - (size_t)count;
    const size_t first = count < 0 ? mark + 1 : mark, depth = p->depth;
    if (kind == GSF__PTH_DICT && (depth - first) % 2 != 0) return gsf__pth_bad(p, "a key without a value");
    GSF__TRY(gsf__pth_make(p, kind, 0, 0));
    const uint32_t node = p->stack[depth];
    for (size_t i = first; i < depth; i += kind == GSF__PTH_DICT ? 2 : 1)
        GSF__TRY(kind == GSF__PTH_DICT ? gsf__pth_add(p, node, p->stack[i], p->stack[i + 1])
                                       : gsf__pth_add(p, node, 0, p->stack[i]));
    p->depth = mark;
    return gsf__pth_push(p, node);
}

// APPENDS, SETITEMS, ADDITEMS: the nodes above the mark are added to the container below it.
static gsf_result gsf__pth_extend(gsf__pth* p, gsf__pth_kind kind) {
    size_t mark;
    GSF__TRY(gsf__pth_find_mark(p, &mark));
    if (mark == 0 || p->nodes[p->stack[mark - 1]].kind != kind) return gsf__pth_bad(p, "a value of the wrong type");
    return gsf__pth_gather(p, mark, p->stack[mark - 1], kind == GSF__PTH_DICT);
}

// APPEND, SETITEM
static gsf_result gsf__pth_append(gsf__pth* p, gsf__pth_kind kind) {
    uint32_t value, key = 0;
    GSF__TRY(gsf__pth_pop(p, GSF__PTH_OTHER, &value));
    if (kind == GSF__PTH_DICT) GSF__TRY(gsf__pth_pop(p, GSF__PTH_OTHER, &key));
    if (!p->depth || p->nodes[p->stack[p->depth - 1]].kind != kind) return gsf__pth_bad(p, "a value of the wrong type");
    return gsf__pth_add(p, p->stack[p->depth - 1], key, value);
}

static gsf_result gsf__pth_remember(gsf__pth* p, uint64_t index) {
    const size_t known = p->memo_count;
    if (!p->depth) return gsf__pth_bad(p, "nothing on the stack");
    if (index >= p->size) return gsf__pth_bad(p, "a memo index larger than the file"); // writers count up from 0
    if (index >= known) {
        GSF__TRY(gsf__reserve(p->ctx, (void**)&p->memo, &p->memo_room, known, (size_t)index + 1, sizeof *p->memo));
        memset(p->memo + known, 0, ((size_t)index + 1 - known) * sizeof *p->memo);
        p->memo_count = (size_t)index + 1;
    }
    p->memo[index] = p->stack[p->depth - 1];
    return GSF_OK;
}

static gsf_result gsf__pth_recall(gsf__pth* p, uint64_t index) {
    if (index >= p->memo_count || !p->memo[index]) return gsf__pth_bad(p, "a memo entry that was never set");
    return gsf__pth_push(p, p->memo[index]);
}

// ---- PyTorch files: tensors and storages

// The member at `index` of a container, which must be of this kind; 0: it is not.
static uint32_t gsf__pth_member_of(const gsf__pth* p, uint32_t container, uint32_t index, gsf__pth_kind kind) {
    uint32_t at = p->nodes[container].first;
    while (at && index--) at = p->members[at].next;
    return at && p->nodes[p->members[at].value].kind == kind ? p->members[at].value : 0;
}

typedef struct gsf__pth_tensor {
    const gsf__pth_storage* storage;
    int64_t offset, shape[GSF_NN_MAX_RANK], stride[GSF_NN_MAX_RANK], count;
    int32_t rank;
    int dense; // row-major without gaps
} gsf__pth_tensor;

// Up to 8 non-negative integers.
static gsf_result gsf__pth_read_dims(const gsf__pth* p, uint32_t tuple, int64_t* out, int32_t* rank) {
    *rank = 0;
    if (p->nodes[tuple].count > GSF_NN_MAX_RANK)
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "pickle: a tensor with more than %d dimensions",
                             (int)GSF_NN_MAX_RANK);
    for (uint32_t at = p->nodes[tuple].first; at; at = p->members[at].next) {
        const gsf__pth_node* node = &p->nodes[p->members[at].value];
        if (node->kind != GSF__PTH_NUMBER || node->value < 0)
            return gsf__pth_bad(p, "a dimension or stride that is no number, or negative");
        out[(*rank)++] = node->value;
    }
    return GSF_OK;
}

// Reads and checks the arguments of _rebuild_tensor and _rebuild_tensor_v2: storage, offset, size, stride, ...
static gsf_result gsf__pth_read_tensor(const gsf__pth* p, uint32_t args, gsf__pth_tensor* out) {
    const uint32_t storage = gsf__pth_member_of(p, args, 0, GSF__PTH_STORAGE);
    const uint32_t offset = gsf__pth_member_of(p, args, 1, GSF__PTH_NUMBER);
    const uint32_t size = gsf__pth_member_of(p, args, 2, GSF__PTH_SEQUENCE);
    const uint32_t stride = gsf__pth_member_of(p, args, 3, GSF__PTH_SEQUENCE);
    int32_t strides;
    memset(out, 0, sizeof *out);
    if (!storage || !offset || !size || !stride) return gsf__pth_bad(p, "a tensor with arguments of the wrong type");
    GSF__TRY(gsf__pth_read_dims(p, size, out->shape, &out->rank));
    GSF__TRY(gsf__pth_read_dims(p, stride, out->stride, &strides));
    if (strides != out->rank) return gsf__pth_bad(p, "a tensor with more dimensions than strides, or fewer");
    out->storage = &p->storages[p->nodes[storage].value];
    out->offset = p->nodes[offset].value;
    out->count = 1;
    out->dense = 1;
    const int64_t room = out->storage->count;
    int64_t last = out->offset; // of the elements in use
    int fits = out->offset >= 0 && out->offset <= room;
    for (int32_t i = out->rank; i-- > 0;) {
        const int64_t n = out->shape[i], step = n > 1 ? out->stride[i] : 0;
        out->stride[i] = step;
        if (n > 1 && step != out->count) out->dense = 0;
        if (n > 0 && out->count > INT64_MAX / 16 / n) return gsf__pth_bad(p, "a tensor whose size overflows");
        if (n > 1 && step > 0 && (n - 1 > (room - gsf__least(last, room)) / step)) fits = 0;
        else if (n > 1) last += (n - 1) * step;
        out->count *= n;
    }
    if (out->count == 0) return GSF_OK;
    return fits && last < room ? GSF_OK : gsf__pth_bad(p, "a tensor that reaches beyond its storage");
}

static int gsf__pth_compare_entries(const void* a, const void* b) {
    const gsf__pth_entry *x = (const gsf__pth_entry*)a, *y = (const gsf__pth_entry*)b;
    const int order = memcmp(x->name, y->name, x->name_size < y->name_size ? x->name_size : y->name_size);
    return order ? order : x->name_size < y->name_size ? -1 : x->name_size > y->name_size;
}

// The entry TOP/NAME of the zip container, which must be stored and not encrypted. *out is NULL if there is none.
static gsf_result gsf__pth_find_entry(const gsf__pth* p, const char* folder, const char* name, size_t name_size,
                                      const gsf__pth_entry** out) {
    char whole[2 * GSF__PTH_NAME_MAX];
    gsf__pth_entry wanted;
    *out = NULL;
    if (name_size >= GSF__PTH_NAME_MAX / 2 || memchr(name, 0, name_size)) return GSF_OK;
    memset(&wanted, 0, sizeof wanted);
    wanted.name = whole;
    wanted.name_size = (size_t)snprintf(whole, sizeof whole, "%s%s%.*s", p->top, folder, (int)name_size, name);
    *out = (const gsf__pth_entry*)bsearch(&wanted, p->entries, p->entry_count, sizeof wanted, gsf__pth_compare_entries);
    if (*out && (((*out)->flags & 1u) || (*out)->method != 0))
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, (*out)->at, "zip: %s is %s", gsf__nn_show(whole).text,
                             (*out)->method ? "compressed" : "encrypted");
    return GSF_OK;
}

// BINPERSID: ("storage", type, key, location, number of elements, and in old files None)
static gsf_result gsf__pth_make_storage(gsf__pth* p) {
    const gsf__pth_entry* entry = NULL;
    gsf__pth_storage s;
    uint32_t tuple;
    GSF__TRY(gsf__pth_pop(p, GSF__PTH_SEQUENCE, &tuple));
    const uint32_t word = gsf__pth_member_of(p, tuple, 0, GSF__PTH_TEXT);
    const uint32_t type = gsf__pth_member_of(p, tuple, 1, GSF__PTH_GLOBAL);
    const uint32_t key = gsf__pth_member_of(p, tuple, 2, GSF__PTH_TEXT);
    const uint32_t count = gsf__pth_member_of(p, tuple, 4, GSF__PTH_NUMBER);
    const uint32_t members = p->nodes[tuple].count;
    if (!word || !type || !key || !count || p->nodes[word].count != 7 ||
        memcmp(p->data + p->nodes[word].value, "storage", 7) != 0 ||
        gsf__pth_globals[p->nodes[type].value].role != GSF__PTH_STORAGE_TYPE)
        return gsf__pth_bad(p, "a persistent id that is no storage");
    if (members > 6 || (members == 6 && !gsf__pth_member_of(p, tuple, 5, GSF__PTH_OTHER)))
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "pickle: a view of another storage");
    memset(&s, 0, sizeof s);
    s.key = (const char*)p->data + p->nodes[key].value;
    s.key_size = p->nodes[key].count;
    s.dtype = gsf__pth_globals[p->nodes[type].value].dtype;
    s.count = p->nodes[count].value;
    const size_t width = gsf_nn_get_dtype_size(s.dtype);
    if (s.count < 0 || (uint64_t)s.count > p->size / width) return gsf__pth_bad(p, "a storage larger than the file");
    if (p->zip) {
        GSF__TRY(gsf__pth_find_entry(p, "data/", s.key, s.key_size, &entry));
        if (!entry) return gsf__pth_bad(p, "a storage that the file does not have");
        if (entry->size != (size_t)s.count * width)
            return gsf__pth_fail(p, GSF_ERROR_FORMAT, entry->at, "a storage of %zu bytes for %lld elements of %s", entry->size,
                                 (long long)s.count, gsf__nn_dtype_name(s.dtype));
        s.data = p->data + entry->at;
    }
    GSF__TRY(gsf__reserve(p->ctx, (void**)&p->storages, &p->storage_room, p->storage_count, p->storage_count + 1,
                          sizeof *p->storages));
    p->storages[p->storage_count] = s;
    return gsf__pth_make(p, GSF__PTH_STORAGE, (int64_t)p->storage_count++, 0);
}

// OrderedDict(), or OrderedDict([[key, value], ...]) as Python 2 writes it
static gsf_result gsf__pth_make_dict(gsf__pth* p, uint32_t args) {
    GSF__TRY(gsf__pth_make(p, GSF__PTH_DICT, 0, 0));
    const uint32_t dict = p->stack[p->depth - 1], list = gsf__pth_member_of(p, args, 0, GSF__PTH_SEQUENCE);
    if (p->nodes[args].count == 0) return GSF_OK;
    if (p->nodes[args].count > 1 || !list) return gsf__pth_bad(p, "an OrderedDict of the wrong arguments");
    for (uint32_t at = p->nodes[list].first; at; at = p->members[at].next) {
        const gsf__pth_node* pair = &p->nodes[p->members[at].value];
        if (pair->kind != GSF__PTH_SEQUENCE || pair->count != 2) return gsf__pth_bad(p, "an OrderedDict of no pairs");
        GSF__TRY(gsf__pth_add(p, dict, p->members[pair->first].value, p->members[pair->last].value));
    }
    p->nodes[list].first = p->nodes[list].last = p->nodes[list].count = 0; // used up, so that calls cannot multiply it
    return GSF_OK;
}

// REDUCE: calls a global with a tuple of arguments.
static gsf_result gsf__pth_call(gsf__pth* p) {
    uint32_t args, callee;
    gsf__pth_tensor tensor;
    GSF__TRY(gsf__pth_pop(p, GSF__PTH_SEQUENCE, &args));
    GSF__TRY(gsf__pth_pop(p, GSF__PTH_GLOBAL, &callee));
    const uint32_t first = p->nodes[args].first ? p->members[p->nodes[args].first].value : 0;
    switch (gsf__pth_globals[p->nodes[callee].value].role) {
        case GSF__PTH_ORDERED_DICT: return gsf__pth_make_dict(p, args);
        case GSF__PTH_REBUILD:
            GSF__TRY(gsf__pth_read_tensor(p, args, &tensor));
            return gsf__pth_make(p, GSF__PTH_TENSOR, args, 0);
        case GSF__PTH_PARAMETER: // of a tensor
            if (!first || p->nodes[first].kind != GSF__PTH_TENSOR) return gsf__pth_bad(p, "a Parameter of no tensor");
            return gsf__pth_push(p, first);
        case GSF__PTH_SIZE: // of a sequence
            if (!first || p->nodes[first].kind != GSF__PTH_SEQUENCE) return gsf__pth_bad(p, "a Size of no sequence");
            return gsf__pth_push(p, first);
        case GSF__PTH_IGNORED: return gsf__pth_make(p, GSF__PTH_OTHER, 0, 0);
        case GSF__PTH_STORAGE_TYPE: break;
    }
    return gsf__pth_bad(p, "a call of something that is no function");
}

static gsf_result gsf__pth_find_global(gsf__pth* p, const char* module, size_t module_size, const char* name,
                                       size_t name_size) {
    for (size_t i = 0; i < GSF__COUNT(gsf__pth_globals); i++)
        if (strlen(gsf__pth_globals[i].module) == module_size && strlen(gsf__pth_globals[i].name) == name_size &&
            memcmp(gsf__pth_globals[i].module, module, module_size) == 0 &&
            memcmp(gsf__pth_globals[i].name, name, name_size) == 0)
            return gsf__pth_make(p, GSF__PTH_GLOBAL, (int64_t)i, 0);
    char whole[100];
    snprintf(whole, sizeof whole, "%.*s.%.*s", (int)(module_size < 40 ? module_size : 40), module,
             (int)(name_size < 40 ? name_size : 40), name);
    return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "pickle: refers to %s, which weights do not need",
                         gsf__nn_show(whole).text);
}

// ---- PyTorch files: opcodes

static gsf_result gsf__pth_take(gsf__pth* p, uint64_t bytes, const unsigned char** out) {
    *out = p->data + p->at;
    if (bytes > p->end - p->at) return gsf__pth_bad(p, "cut off");
    p->at += (size_t)bytes;
    return GSF_OK;
}

// The little-endian integer of `bytes` bytes that follows an opcode.
static gsf_result gsf__pth_take_number(gsf__pth* p, int bytes, uint64_t* out) {
    const unsigned char* data;
    *out = 0;
    GSF__TRY(gsf__pth_take(p, (uint64_t)bytes, &data));
    *out = gsf__load_le(data, bytes);
    return GSF_OK;
}

static gsf_result gsf__pth_take_line(gsf__pth* p, const char** text, size_t* size) {
    const unsigned char *data = p->data + p->at, *end = (const unsigned char*)memchr(data, '\n', p->end - p->at);
    if (!end) return gsf__pth_bad(p, "cut off");
    *text = (const char*)data;
    *size = (size_t)(end - data);
    p->at += *size + 1;
    return GSF_OK;
}

// Text or bytes, after a length of `bytes` bytes.
static gsf_result gsf__pth_make_text(gsf__pth* p, int bytes, gsf__pth_kind kind) {
    const unsigned char* data;
    uint64_t size;
    GSF__TRY(gsf__pth_take_number(p, bytes, &size));
    GSF__TRY(gsf__pth_take(p, size, &data));
    if (size > INT32_MAX) return gsf__pth_bad(p, "a text of more than 2 GiB");
    return gsf__pth_make(p, kind, data - p->data, kind == GSF__PTH_TEXT ? (uint32_t)size : 0);
}

// An integer of any length, in two's complement; more than 8 bytes, and no tensor needs it.
static gsf_result gsf__pth_make_long(gsf__pth* p, int bytes) {
    const unsigned char* data;
    uint64_t size, value;
    GSF__TRY(gsf__pth_take_number(p, bytes, &size));
    GSF__TRY(gsf__pth_take(p, size, &data));
    if (size > 8) return gsf__pth_make(p, GSF__PTH_OTHER, 0, 0);
    value = gsf__load_le(data, (int)size);
    if (size > 0 && size < 8 && (data[size - 1] & 0x80)) value |= UINT64_MAX << 8 * size;
    int64_t number;
    memcpy(&number, &value, sizeof number);
    return gsf__pth_make(p, GSF__PTH_NUMBER, number, 0);
}

// Opcodes that push a constant. *done is 0 if `opcode` is none of them.
static gsf_result gsf__pth_literal(gsf__pth* p, unsigned char opcode, int* done) {
    uint64_t value;
    *done = 1;
    switch (opcode) {
        case '(': return gsf__pth_make(p, GSF__PTH_MARK, 0, 0);
        case 'N': return gsf__pth_make(p, GSF__PTH_OTHER, 0, 0);
        case 0x88: case 0x89: return gsf__pth_make(p, GSF__PTH_NUMBER, opcode == 0x88, 0); // True, False
        case 'K': case 'M': case 'J': // 1, 2 and 4 bytes, of which only the last have a sign
            GSF__TRY(gsf__pth_take_number(p, opcode == 'K' ? 1 : opcode == 'M' ? 2 : 4, &value));
            return gsf__pth_make(p, GSF__PTH_NUMBER, opcode == 'J' ? (int32_t)(uint32_t)value : (int64_t)value, 0);
        case 0x8a: return gsf__pth_make_long(p, 1);
        case 0x8b: return gsf__pth_make_long(p, 4);
        case 'G': // a double
            GSF__TRY(gsf__pth_take_number(p, 8, &value));
            return gsf__pth_make(p, GSF__PTH_OTHER, 0, 0);
        case 'U': case 0x8c: return gsf__pth_make_text(p, 1, GSF__PTH_TEXT);
        case 'T': case 'X': return gsf__pth_make_text(p, 4, GSF__PTH_TEXT);
        case 0x8d: return gsf__pth_make_text(p, 8, GSF__PTH_TEXT);
        case 'C': return gsf__pth_make_text(p, 1, GSF__PTH_OTHER);
        case 'B': return gsf__pth_make_text(p, 4, GSF__PTH_OTHER);
        case 0x8e: return gsf__pth_make_text(p, 8, GSF__PTH_OTHER);
        default: *done = 0; return GSF_OK;
    }
}

// Opcodes for tuples, lists, dictionaries and sets.
static gsf_result gsf__pth_container(gsf__pth* p, unsigned char opcode, int* done) {
    *done = 1;
    switch (opcode) {
        case ')': case ']': case 0x8f: return gsf__pth_make(p, GSF__PTH_SEQUENCE, 0, 0);
        case '}': return gsf__pth_make(p, GSF__PTH_DICT, 0, 0);
        case 0x85: case 0x86: case 0x87: return gsf__pth_collect(p, GSF__PTH_SEQUENCE, opcode - 0x84);
        case 't': case 'l': case 0x91: return gsf__pth_collect(p, GSF__PTH_SEQUENCE, -1);
        case 'd': return gsf__pth_collect(p, GSF__PTH_DICT, -1);
        case 'a': return gsf__pth_append(p, GSF__PTH_SEQUENCE);
        case 's': return gsf__pth_append(p, GSF__PTH_DICT);
        case 'e': case 0x90: return gsf__pth_extend(p, GSF__PTH_SEQUENCE);
        case 'u': return gsf__pth_extend(p, GSF__PTH_DICT);
        default: *done = 0; return GSF_OK;
    }
}

// Opcodes for the memo and the stack.
static gsf_result gsf__pth_memory(gsf__pth* p, unsigned char opcode, int* done) {
    uint64_t index;
    uint32_t node;
    size_t mark;
    *done = 1;
    switch (opcode) {
        case 'q': case 'r':
            GSF__TRY(gsf__pth_take_number(p, opcode == 'q' ? 1 : 4, &index));
            return gsf__pth_remember(p, index);
        case 0x94: return gsf__pth_remember(p, p->memo_count);
        case 'h': case 'j':
            GSF__TRY(gsf__pth_take_number(p, opcode == 'h' ? 1 : 4, &index));
            return gsf__pth_recall(p, index);
        case '0': return gsf__pth_pop(p, GSF__PTH_OTHER, &node);
        case '1':
            GSF__TRY(gsf__pth_find_mark(p, &mark));
            p->depth = mark;
            return GSF_OK;
        case '2':
            GSF__TRY(gsf__pth_pop(p, GSF__PTH_OTHER, &node));
            GSF__TRY(gsf__pth_push(p, node));
            return gsf__pth_push(p, node);
        default: *done = 0; return GSF_OK;
    }
}

static gsf_result gsf__pth_object(gsf__pth* p, unsigned char opcode) { // globals and their instances
    const char *module = NULL, *name = NULL;
    size_t module_size = 0, name_size = 0;
    uint32_t a, b;
    switch (opcode) {
        case 'c':
            GSF__TRY(gsf__pth_take_line(p, &module, &module_size));
            GSF__TRY(gsf__pth_take_line(p, &name, &name_size));
            return gsf__pth_find_global(p, module, module_size, name, name_size);
        case 0x93:
            GSF__TRY(gsf__pth_pop(p, GSF__PTH_TEXT, &b));
            GSF__TRY(gsf__pth_pop(p, GSF__PTH_TEXT, &a));
            return gsf__pth_find_global(p, (const char*)p->data + p->nodes[a].value, p->nodes[a].count,
                                        (const char*)p->data + p->nodes[b].value, p->nodes[b].count);
        case 'Q': return gsf__pth_make_storage(p);
        case 'R': return gsf__pth_call(p);
        case 'b': // attributes: a state dictionary has versions of its modules, which tensors do not need
            GSF__TRY(gsf__pth_pop(p, GSF__PTH_OTHER, &a));
            if (p->depth && p->nodes[p->stack[p->depth - 1]].kind == GSF__PTH_DICT) return GSF_OK;
            return gsf__pth_bad(p, "attributes of something else than a dictionary");
        default: return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "pickle: opcode 0x%02x", (unsigned)opcode);
    }
}

// Runs the pickle at p->at; *out is the object that it makes.
static gsf_result gsf__pth_run(gsf__pth* p, size_t end, uint32_t* out) {
    uint64_t ignored;
    int done = 0;
    p->end = end;
    p->depth = p->memo_count = 0;
    for (;;) {
        p->opcode = p->at;
        if (p->at >= p->end) return gsf__pth_bad(p, "ends without STOP");
        const unsigned char opcode = p->data[p->at++];
        if (opcode == '.') return gsf__pth_pop(p, GSF__PTH_OTHER, out);
        if (opcode == 0x80 || opcode == 0x95) { // protocol, size of a frame
            GSF__TRY(gsf__pth_take_number(p, opcode == 0x80 ? 1 : 8, &ignored));
            continue;
        }
        GSF__TRY(gsf__pth_literal(p, opcode, &done));
        if (!done) GSF__TRY(gsf__pth_container(p, opcode, &done));
        if (!done) GSF__TRY(gsf__pth_memory(p, opcode, &done));
        if (!done) GSF__TRY(gsf__pth_object(p, opcode));
    }
}

// ---- PyTorch files: the zip container

enum { GSF__ZIP_END = 22, GSF__ZIP_CENTRAL = 46, GSF__ZIP_LOCAL = 30, GSF__ZIP_END64 = 56, GSF__ZIP_LOCATOR = 20 };

typedef struct gsf__zip_directory { uint64_t count, at, size; } gsf__zip_directory;

// Replaces values that do not fit 32 bits by those of the zip64 extra field.
static void gsf__zip_widen(const unsigned char* extra, size_t size, uint64_t* const* values, int count) {
    for (size_t at = 0; size - at >= 4;) {
        const size_t bytes = (size_t)gsf__load_le(extra + at + 2, 2);
        const unsigned char *from = extra + at + 4, *end = from + bytes;
        if (bytes > size - at - 4) return;
        for (int i = 0; gsf__load_le(extra + at, 2) == 1 && i < count; i++) {
            if (*values[i] != UINT32_MAX || end - from < 8) continue;
            *values[i] = gsf__load_le(from, 8);
            from += 8;
        }
        at += 4 + bytes;
    }
}

static gsf_result gsf__zip_find_directory(const gsf__pth* p, gsf__zip_directory* out) {
    const unsigned char* data = p->data;
    size_t end = p->size;
    memset(out, 0, sizeof *out);
    for (size_t back = GSF__ZIP_END; back <= p->size && back <= GSF__ZIP_END + 65535; back++)
        if (memcmp(data + p->size - back, "PK\5\6", 4) == 0 &&
            gsf__load_le(data + p->size - back + 20, 2) == back - GSF__ZIP_END) {
            end = p->size - back;
            break;
        }
    if (end == p->size) return gsf__pth_fail(p, GSF_ERROR_FORMAT, p->size, "zip: no end of the directory: truncated");
    out->count = gsf__load_le(data + end + 10, 2);
    out->size = gsf__load_le(data + end + 12, 4);
    out->at = gsf__load_le(data + end + 16, 4);
    if ((out->count == UINT16_MAX || out->size == UINT32_MAX || out->at == UINT32_MAX) && end >= GSF__ZIP_LOCATOR &&
        memcmp(data + end - GSF__ZIP_LOCATOR, "PK\6\7", 4) == 0) {
        const uint64_t wide = gsf__load_le(data + end - GSF__ZIP_LOCATOR + 8, 8);
        if (wide > end || end - wide < GSF__ZIP_END64 || memcmp(data + wide, "PK\6\6", 4) != 0)
            return gsf__pth_fail(p, GSF_ERROR_FORMAT, end, "zip: no end of the directory where the locator points");
        out->count = gsf__load_le(data + wide + 32, 8);
        out->size = gsf__load_le(data + wide + 40, 8);
        out->at = gsf__load_le(data + wide + 48, 8);
        end = (size_t)wide;
    }
    if (out->at > end || out->size > end - out->at || out->count > out->size / GSF__ZIP_CENTRAL)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, end, "zip: a directory of %llu entries and %llu bytes does not fit",
                             (unsigned long long)out->count, (unsigned long long)out->size);
    return GSF_OK;
}

// Reads an entry of the directory at `at` and the local header that it points to.
static gsf_result gsf__zip_read_entry(const gsf__pth* p, const gsf__zip_directory* directory, size_t at,
                                      gsf__pth_entry* out, size_t* next) {
    const unsigned char* e = p->data + at;
    const size_t left = (size_t)(directory->at + directory->size) - at;
    if (left < GSF__ZIP_CENTRAL || memcmp(e, "PK\1\2", 4) != 0)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, at, "zip: no entry of the directory");
    const size_t name = (size_t)gsf__load_le(e + 28, 2), extra = (size_t)gsf__load_le(e + 30, 2);
    const size_t comment = (size_t)gsf__load_le(e + 32, 2);
    if (name + extra + comment > left - GSF__ZIP_CENTRAL)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, at, "zip: an entry that is longer than the directory");
    *next = at + GSF__ZIP_CENTRAL + name + extra + comment;
    uint64_t packed = gsf__load_le(e + 20, 4), size = gsf__load_le(e + 24, 4), local = gsf__load_le(e + 42, 4);
    uint64_t* const values[3] = {&size, &packed, &local};
    gsf__zip_widen(e + GSF__ZIP_CENTRAL + name, extra, values, 3);
    out->name = (const char*)e + GSF__ZIP_CENTRAL;
    out->name_size = name;
    out->flags = (unsigned)gsf__load_le(e + 8, 2);
    out->method = (unsigned)gsf__load_le(e + 10, 2);
    if (local > directory->at || directory->at - local < GSF__ZIP_LOCAL || memcmp(p->data + local, "PK\3\4", 4) != 0)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, at, "zip: an entry without local header");
    const unsigned char* head = p->data + local;
    const uint64_t begin = local + GSF__ZIP_LOCAL + gsf__load_le(head + 26, 2) + gsf__load_le(head + 28, 2);
    if (gsf__load_le(head + 26, 2) != name || begin > directory->at ||
        memcmp(head + GSF__ZIP_LOCAL, out->name, name) != 0)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, (size_t)local, "zip: a local header of another entry");
    if (packed > directory->at - begin || (out->method == 0 && packed != size))
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, (size_t)local, "zip: an entry of %llu bytes that the file does not have",
                             (unsigned long long)packed);
    out->at = (size_t)begin;
    out->size = (size_t)packed;
    return GSF_OK;
}

static gsf_result gsf__zip_read(gsf__pth* p) {
    gsf__zip_directory directory;
    GSF__TRY(gsf__zip_find_directory(p, &directory));
    p->entries = (gsf__pth_entry*)gsf_alloc(p->ctx, (size_t)directory.count + 1, sizeof *p->entries);
    if (!p->entries) return GSF_ERROR_OUT_OF_MEMORY;
    size_t at = (size_t)directory.at;
    for (; p->entry_count < directory.count; p->entry_count++)
        GSF__TRY(gsf__zip_read_entry(p, &directory, at, &p->entries[p->entry_count], &at));
    if (p->entry_count) qsort(p->entries, p->entry_count, sizeof *p->entries, gsf__pth_compare_entries);
    return GSF_OK;
}

// Finds TOP/data.pkl and runs it.
static gsf_result gsf__pth_run_zip(gsf__pth* p, uint32_t* root) {
    static const char pickle[] = "data.pkl";
    const size_t size = sizeof pickle - 1;
    const gsf__pth_entry *entry = NULL, *order;
    p->zip = 1;
    GSF__TRY(gsf__zip_read(p));
    for (size_t i = 0; i < p->entry_count && !entry; i++) {
        const gsf__pth_entry* e = &p->entries[i];
        if (e->name_size < size || e->name_size - size >= GSF__PTH_NAME_MAX / 2 ||
            memcmp(e->name + e->name_size - size, pickle, size) != 0 || memchr(e->name, 0, e->name_size))
            continue;
        if (e->name_size > size && e->name[e->name_size - size - 1] != '/') continue;
        snprintf(p->top, sizeof p->top, "%.*s", (int)(e->name_size - size), e->name);
        GSF__TRY(gsf__pth_find_entry(p, "", pickle, size, &entry));
    }
    if (!entry) return gsf__pth_fail(p, GSF_ERROR_FORMAT, 0, "zip: no data.pkl: not a PyTorch file");
    GSF__TRY(gsf__pth_find_entry(p, "", "byteorder", 9, &order));
    if (order && order->size == 3 && memcmp(p->data + order->at, "big", 3) == 0)
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, order->at, "big-endian");
    p->at = entry->at;
    return gsf__pth_run(p, entry->at + entry->size, root);
}

// ---- PyTorch files: the legacy container

static const unsigned char gsf__pth_magic[15] = {0x80, 2, 0x8a, 10, 0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50,
                                                 0x19, '.'};

static int gsf__pth_compare_storages(const void* a, const void* b) {
    const gsf__pth_storage *x = *(gsf__pth_storage* const*)a, *y = *(gsf__pth_storage* const*)b;
    const int order = memcmp(x->key, y->key, x->key_size < y->key_size ? x->key_size : y->key_size);
    return order ? order : x->key_size < y->key_size ? -1 : x->key_size > y->key_size;
}

// Gives the storages of one key, all of those in `order` that compare equal to it, the data at p->at.
static gsf_result gsf__pth_place_storage(gsf__pth* p, gsf__pth_storage** order, const gsf__pth_node* key) {
    gsf__pth_storage wanted, *address = &wanted;
    memset(&wanted, 0, sizeof wanted);
    wanted.key = (const char*)p->data + key->value;
    wanted.key_size = key->count;
    size_t low = 0, high = p->storage_count;
    while (low < high) { // the first that is not smaller
        const size_t middle = low + (high - low) / 2;
        if (gsf__pth_compare_storages(&order[middle], &address) < 0) low = middle + 1;
        else high = middle;
    }
    uint64_t count;
    if (low == p->storage_count || gsf__pth_compare_storages(&order[low], &address) != 0)
        return gsf__pth_bad(p, "the key of a storage that no tensor uses");
    if (order[low]->data) return gsf__pth_bad(p, "a storage key occurs twice");
    p->opcode = p->at;
    GSF__TRY(gsf__pth_take_number(p, 8, &count));
    const unsigned char* data = p->data + p->at;
    const size_t width = gsf_nn_get_dtype_size(order[low]->dtype);
    for (; low < p->storage_count && gsf__pth_compare_storages(&order[low], &address) == 0; low++) {
        if ((uint64_t)order[low]->count != count || gsf_nn_get_dtype_size(order[low]->dtype) != width)
            return gsf__pth_fail(p, GSF_ERROR_FORMAT, p->opcode, "a storage of %llu elements, not of %lld as its tensor says",
                                 (unsigned long long)count, (long long)order[low]->count);
        order[low]->data = data;
    }
    return gsf__pth_take(p, count * width, &data); // cannot overflow: gsf__pth_make_storage checked the count
}

static gsf_result gsf__pth_place_storages(gsf__pth* p, uint32_t keys) {
    gsf__pth_storage** order = (gsf__pth_storage**)gsf_alloc(p->ctx, p->storage_count + 1, sizeof *order);
    if (!order) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < p->storage_count; i++) order[i] = &p->storages[i];
    if (p->storage_count) qsort((void*)order, p->storage_count, sizeof *order, gsf__pth_compare_storages);
    p->end = p->size;
    for (uint32_t at = p->nodes[keys].first; at && !result; at = p->members[at].next) {
        const gsf__pth_node* key = &p->nodes[p->members[at].value];
        result = key->kind == GSF__PTH_TEXT ? gsf__pth_place_storage(p, order, key)
                                            : gsf__pth_bad(p, "a key that is no text");
    }
    for (size_t i = 0; i < p->storage_count && !result; i++)
        if (!p->storages[i].data) result = gsf__pth_bad(p, "a storage without data");
    gsf_free(p->ctx, (void*)order);
    return result;
}

static gsf_result gsf__pth_run_legacy(gsf__pth* p, uint32_t* root) {
    uint32_t version, platform, keys;
    if (p->size < sizeof gsf__pth_magic || memcmp(p->data, gsf__pth_magic, sizeof gsf__pth_magic) != 0)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, 0, "neither safetensors nor PyTorch: a pickle without magic number");
    p->at = sizeof gsf__pth_magic;
    GSF__TRY(gsf__pth_run(p, p->size, &version));
    if (p->nodes[version].kind != GSF__PTH_NUMBER || p->nodes[version].value != 1001)
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "not version 1001 of PyTorch's legacy format");
    GSF__TRY(gsf__pth_run(p, p->size, &platform));
    for (uint32_t at = p->nodes[platform].first; at; at = p->members[at].next) {
        const gsf__pth_node *key = &p->nodes[p->members[at].key], *value = &p->nodes[p->members[at].value];
        if (key->kind == GSF__PTH_TEXT && key->count == 13 && memcmp(p->data + key->value, "little_endian", 13) == 0 &&
            value->value != 1)
            return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "big-endian");
    }
    GSF__TRY(gsf__pth_run(p, p->size, root));
    GSF__TRY(gsf__pth_run(p, p->size, &keys));
    if (p->nodes[keys].kind != GSF__PTH_SEQUENCE) return gsf__pth_bad(p, "no list of storage keys");
    return gsf__pth_place_storages(p, keys);
}

// ---- PyTorch files: from objects to tensors

enum { GSF__PTH_NAMELESS = -1 };

// Sets p->path to the name of a member below a container whose name has frame->path_size bytes. Returns its length, or
// GSF__PTH_NAMELESS if it is empty, too long, not UTF-8, or if a key on the way is neither text nor number.
static int64_t gsf__pth_name_member(gsf__pth* p, const gsf__pth_frame* frame, const gsf__pth_member* member) {
    const gsf__pth_node* key = &p->nodes[member->key];
    const char* text = (const char*)p->data + key->value;
    char number[24];
    int64_t size = key->count, at = frame->path_size;
    if (member->key && key->kind != GSF__PTH_TEXT && key->kind != GSF__PTH_NUMBER) return GSF__PTH_NAMELESS;
    if (!member->key || key->kind == GSF__PTH_NUMBER) {
        size = snprintf(number, sizeof number, "%lld", member->key ? (long long)key->value : (long long)frame->index);
        text = number;
    }
    if (at < 0 || size == 0 || at + 1 + size >= GSF__PTH_NAME_MAX) return GSF__PTH_NAMELESS;
    for (int64_t i = 0, step; i < size; i += step) {
        step = text[i] ? (int64_t)gsf__utf8_size(text + i, (size_t)(size - i)) : 0;
        if (!step) return GSF__PTH_NAMELESS;
    }
    if (at > 0) p->path[at++] = '/';
    memcpy(p->path + at, text, (size_t)size);
    p->path[at + size] = 0;
    return at + size;
}

static gsf_result gsf__pth_enter(gsf__pth* p, uint32_t container, int64_t path_size) {
    gsf__pth_node* node = &p->nodes[container];
    if (node->walked == p->walk) return GSF_OK; // reached before: tensors keep the first of their containers' names
    node->walked = p->walk;
    GSF__TRY(gsf__reserve(p->ctx, (void**)&p->frames, &p->frame_room, p->frame_count, p->frame_count + 1,
                          sizeof *p->frames));
    gsf__pth_frame* frame = &p->frames[p->frame_count++];
    frame->member = node->first;
    frame->index = 0;
    frame->path_size = path_size;
    return GSF_OK;
}

static void gsf__pth_copy(const gsf__pth_tensor* t, unsigned char* out) { // strided to dense
    const size_t width = gsf_nn_get_dtype_size(t->storage->dtype);
    int64_t index[GSF_NN_MAX_RANK], from = t->offset;
    memset(index, 0, sizeof index);
    for (int64_t i = 0; i < t->count; i++, out += width) {
        memcpy(out, t->storage->data + (size_t)from * width, width);
        for (int32_t d = t->rank; d-- > 0;) {
            from += t->stride[d];
            if (++index[d] < t->shape[d]) break;
            from -= t->stride[d] * t->shape[d];
            index[d] = 0;
        }
    }
}

// Counts a tensor called p->path, or with `weights` stores it.
static gsf_result gsf__pth_found(gsf__pth* p, uint32_t node, int64_t name, gsf_nn_weights* weights, gsf__nn_file* file) {
    gsf__pth_tensor t;
    if (name == GSF__PTH_NAMELESS)
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "pickle: a tensor without a name of UTF-8 below %d bytes",
                             (int)GSF__PTH_NAME_MAX);
    const size_t name_size = (size_t)name;
    GSF__TRY(gsf__pth_read_tensor(p, (uint32_t)p->nodes[node].value, &t));
    const size_t bytes = (size_t)t.count * gsf_nn_get_dtype_size(t.storage->dtype), copied = t.dense ? 0 : bytes;
    if (weights) {
        gsf_nn_tensor* tensor = &weights->tensors[weights->tensor_count++];
        memset(tensor, 0, sizeof *tensor);
        memcpy(file->names + p->names_size, p->path, name_size + 1);
        tensor->name = file->names + p->names_size;
        tensor->dtype = t.storage->dtype;
        tensor->rank = t.rank;
        memcpy(tensor->shape, t.shape, sizeof tensor->shape);
        tensor->count = t.count;
        tensor->data = t.storage->data + (t.count ? (size_t)t.offset : 0) * gsf_nn_get_dtype_size(t.storage->dtype);
        if (copied) {
            tensor->data = file->copies + p->copies_size;
            gsf__pth_copy(&t, file->copies + p->copies_size);
        }
    }
    p->tensor_count++;
    p->names_size += name_size + 1;
    p->copies_size += copied;
    if (p->names_size > 8 * p->size || p->copies_size > 8 * p->size)
        return gsf__pth_fail(p, GSF_ERROR_UNSUPPORTED, p->opcode, "tensors that need more than 8 times the file's size");
    return GSF_OK;
}

// Visits all tensors below the root, in the order of the file.
static gsf_result gsf__pth_walk(gsf__pth* p, uint32_t root, gsf_nn_weights* weights, gsf__nn_file* file) {
    p->walk++;
    p->tensor_count = p->names_size = p->copies_size = 0;
    if (p->nodes[root].kind != GSF__PTH_DICT && p->nodes[root].kind != GSF__PTH_SEQUENCE)
        return gsf__pth_fail(p, GSF_ERROR_FORMAT, p->opcode, "pickle: neither a dictionary nor a list");
    GSF__TRY(gsf__pth_enter(p, root, 0));
    while (p->frame_count) {
        gsf__pth_frame* frame = &p->frames[p->frame_count - 1];
        if (!frame->member) {
            p->frame_count--;
            continue;
        }
        const gsf__pth_member member = p->members[frame->member];
        const gsf__pth_node* value = &p->nodes[member.value];
        const int inner = (value->kind == GSF__PTH_DICT || value->kind == GSF__PTH_SEQUENCE) && value->first;
        const int64_t size = inner || value->kind == GSF__PTH_TENSOR ? gsf__pth_name_member(p, frame, &member) : 0;
        frame->member = member.next;
        frame->index++;
        if (value->kind == GSF__PTH_TENSOR) GSF__TRY(gsf__pth_found(p, member.value, size, weights, file));
        if (inner) GSF__TRY(gsf__pth_enter(p, member.value, size));
    }
    return GSF_OK;
}

// Names that all begin with the same "state_dict/" or the like lose it.
static void gsf__pth_strip(gsf_nn_tensor* tensors, size_t count) {
    for (;;) {
        const char* slash = count ? strchr(tensors[0].name, '/') : NULL;
        if (!slash || !slash[1]) return;
        const size_t size = (size_t)(slash - tensors[0].name) + 1;
        for (size_t i = 1; i < count; i++)
            if (strncmp(tensors[i].name, tensors[0].name, size) != 0 || !tensors[i].name[size]) return;
        for (size_t i = 0; i < count; i++) tensors[i].name += size;
    }
}

static gsf_result gsf__pth_store(gsf__pth* p, uint32_t root, gsf_nn_weights* weights, gsf__nn_file* file) {
    gsf__nn_files* files = (gsf__nn_files*)weights->files;
    const size_t first = weights->tensor_count;
    GSF__TRY(gsf__pth_walk(p, root, NULL, file));
    file->names = (char*)gsf_alloc(p->ctx, p->names_size + 1, 1);
    file->copies = p->copies_size ? (unsigned char*)gsf_alloc(p->ctx, p->copies_size, 1) : NULL;
    if (!file->names || (p->copies_size && !file->copies)) return GSF_ERROR_OUT_OF_MEMORY;
    GSF__TRY(gsf__reserve(p->ctx, (void**)&weights->tensors, &files->tensor_capacity, first, first + p->tensor_count + 1,
                          sizeof *weights->tensors));
    GSF__TRY(gsf__pth_walk(p, root, weights, file));
    file->names_size = p->names_size;
    weights->read_bytes += p->copies_size;
    gsf__pth_strip(weights->tensors + first, p->tensor_count);
    return GSF_OK;
}

// A zip file, or a pickle; a safetensors file may begin with the same bytes, but then continues with '{'.
static int gsf__pth_is(const gsf__nn_file* file) {
    if (file->size < 9 || file->data[8] == '{') return 0;
    return memcmp(file->data, "PK\3\4", 4) == 0 || memcmp(file->data, "PK\5\6", 4) == 0 ||
           (file->data[0] == 0x80 && file->data[1] < 6 && gsf__load_le(file->data, 8) > GSF__NN_HEADER_MAX);
}

static gsf_result gsf__pth_read(gsf_context* ctx, const char* name, gsf_nn_weights* weights, gsf__nn_file* file) {
    gsf__pth* p = (gsf__pth*)gsf_alloc_zeroed(ctx, 1, sizeof *p);
    uint32_t root = 0;
    if (!p) return GSF_ERROR_OUT_OF_MEMORY;
    p->ctx = ctx;
    p->name = gsf__nn_path_end(name);
    p->data = file->data;
    p->size = file->size;
    p->node_count = p->member_count = 1;
    gsf_result result = gsf__reserve(ctx, (void**)&p->nodes, &p->node_room, 0, 1, sizeof *p->nodes);
    if (!result) result = gsf__reserve(ctx, (void**)&p->members, &p->member_room, 0, 1, sizeof *p->members);
    if (!result) memset(p->nodes, 0, sizeof *p->nodes), memset(p->members, 0, sizeof *p->members);
    if (!result) result = p->data[0] == 'P' ? gsf__pth_run_zip(p, &root) : gsf__pth_run_legacy(p, &root);
    if (!result) result = gsf__pth_store(p, root, weights, file);
    gsf_free(ctx, p->nodes);
    gsf_free(ctx, p->members);
    gsf_free(ctx, p->stack);
    gsf_free(ctx, p->memo);
    gsf_free(ctx, p->storages);
    gsf_free(ctx, p->entries);
    gsf_free(ctx, p->frames);
    gsf_free(ctx, p);
    return result;
}

// ---- files and folders

static void gsf__nn_release(gsf_context* ctx, const unsigned char* data, size_t size, gsf__nn_holder holder) {
    if (holder == GSF__NN_READ) gsf_free(ctx, (void*)(uintptr_t)data);
    if (holder == GSF__NN_MAPPED) gsf__nn_unmap(data, size);
}

// Takes ownership of the bytes, also on failure.
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
    return gsf__pth_is(file) ? gsf__pth_read(ctx, name, weights, file) : gsf__nn_read_header(ctx, name, weights, file);
}

static gsf_result gsf__nn_add_file(gsf_context* ctx, const char* path, gsf_nn_weights* weights) {
    const unsigned char* mapping = NULL;
    void* data = NULL;
    size_t size = 0;
    if (gsf__io_is_plain(ctx)) GSF__TRY(gsf__nn_map(ctx, path, &mapping, &size));
    if (mapping) return gsf__nn_add_bytes(ctx, path, mapping, size, GSF__NN_MAPPED, weights);
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    return gsf__nn_add_bytes(ctx, path, (const unsigned char*)data, size, GSF__NN_READ, weights);
}

// Rejects shard names that would lead outside the index's folder.
static int gsf__nn_is_plain_name(const gsf_json_value* value) {
    return value->type == GSF_JSON_STRING && value->string_size > 0 && strlen(value->string) == value->string_size &&
           !strpbrk(value->string, "/\\:") && value->string[0] != '.';
}

typedef struct gsf__nn_index { // weight_map of a sharded model while it is being read
    gsf_context* ctx;
    const char* name;
    size_t folder_size;       // the shards' names follow this many bytes of `path`
    gsf_buffer path;
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
            return gsf_fail(index->ctx, GSF_ERROR_FORMAT, "%s:%u: tensor %s: not a plain file name", index->name,
                            (unsigned)value->offset, gsf__nn_show(value->key).text);
        size_t k = files->count; // from the last one, which usually matches
        while (k > 0 && strcmp(index->shards[k - 1], value->string) != 0) k--;
        if (k > 0) continue;
        GSF__TRY(gsf__reserve(index->ctx, (void**)&index->shards, &index->shard_capacity, files->count, files->count + 1,
                              sizeof *index->shards));
        index->shards[files->count] = value->string;
        index->path.size = index->folder_size;
        gsf_append_bytes(index->ctx, &index->path, value->string, value->string_size);
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
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: two tensors are called %s", weights->name,
                            gsf__nn_show(weights->tensors[i].name).text);
    return GSF_OK;
}

// Checks that every tensor of the map came from the file that the map names.
static gsf_result gsf__nn_check_index(const gsf__nn_index* index, const gsf_nn_weights* weights) {
    const gsf__nn_files* files = (const gsf__nn_files*)weights->files;
    for (uint32_t i = index->map->child; i; i = index->json.values[i].next) {
        const gsf_json_value* value = &index->json.values[i];
        const gsf_nn_tensor* tensor = gsf_nn_find_tensor(weights, value->key);
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
    index.map = gsf_find_json_member(&index.json, &index.json.values[0], "weight_map");
    if (!index.map || index.map->type != GSF_JSON_OBJECT) {
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: no \"weight_map\" object", index.name);
    } else {
        const char* slash = strrchr(path, '/');
        index.folder_size = slash ? (size_t)(slash - path) + 1 : 0;
        gsf_append_bytes(ctx, &index.path, path, index.folder_size);
        result = gsf__nn_open_shards(&index, weights);
        if (result == GSF_OK) result = gsf__nn_sort_names(ctx, weights);
        if (result == GSF_OK) result = gsf__nn_check_index(&index, weights);
    }
    gsf_free(ctx, (void*)index.shards);
    gsf_destroy_buffer(ctx, &index.path);
    gsf_destroy_json(ctx, &index.json);
    return result;
}

// Restores the log hook after reading a file that was allowed to be missing.
static gsf_result gsf__nn_end_quiet(gsf_context* ctx, const gsf_logger* logger, gsf_result result) {
    ctx->logger = *logger;
    if (result != GSF_OK && result != GSF_ERROR_NOT_FOUND) gsf_log(ctx, GSF_LOG_ERROR, "%s", ctx->error);
    return result;
}

// Reads a file that may be missing: *data is then NULL, and neither the log nor ctx->error mentions it.
static gsf_result gsf__nn_read_if_there(gsf_context* ctx, const char* path, void** data, size_t* size) {
    const gsf_logger logger = ctx->logger;
    char error[sizeof ctx->error];
    memcpy(error, ctx->error, sizeof error);
    memset(&ctx->logger, 0, sizeof ctx->logger);
    *data = NULL;
    const gsf_result result = gsf__nn_end_quiet(ctx, &logger, gsf_read_file(ctx, path, data, size));
    if (result != GSF_ERROR_NOT_FOUND) return result;
    memcpy(ctx->error, error, sizeof error);
    return GSF_OK;
}

// Opens <path>.index.json, else <path>. *found is 0 if neither exists, which is an error unless `may_lack`.
static gsf_result gsf__nn_open_either(gsf_context* ctx, gsf_buffer* path, int may_lack, int* found,
                                      gsf_nn_weights* weights) {
    const gsf_logger logger = ctx->logger;
    const size_t plain = path->size;
    void* data = NULL;
    size_t size;
    gsf_append_bytes(ctx, path, ".index.json", 11);
    if (path->failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = gsf__nn_read_if_there(ctx, path->data, &data, &size);
    *found = data != NULL;
    if (*found) {
        result = gsf__nn_read_index(ctx, path->data, data, size, weights);
        gsf_free(ctx, data);
    }
    if (*found || result) return result;
    path->data[plain] = 0;
    if (may_lack) memset(&ctx->logger, 0, sizeof ctx->logger);
    result = gsf__nn_add_file(ctx, path->data, weights);
    if (may_lack) (void)gsf__nn_end_quiet(ctx, &logger, result);
    *found = result == GSF_OK;
    if (result == GSF_OK) return gsf__nn_sort_names(ctx, weights);
    return may_lack && result == GSF_ERROR_NOT_FOUND ? GSF_OK : result;
}

static gsf_result gsf__nn_open_named(gsf_context* ctx, const char* folder, const char* name, int may_lack, int* found,
                                     gsf_nn_weights* weights) {
    gsf_buffer path;
    memset(&path, 0, sizeof path);
    gsf_append_text(ctx, &path, "%s%s%s", folder, gsf__nn_ends_in(folder, "/") ? "" : "/", name);
    const gsf_result result =
        path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf__nn_open_either(ctx, &path, may_lack, found, weights);
    gsf_destroy_buffer(ctx, &path);
    return result;
}

// FOLDER/PREFIX.safetensors, whole or sharded, else FOLDER/PREFIX.pth or .pth.tar.
static gsf_result gsf__nn_open_prefix(gsf_context* ctx, const char* folder, const char* prefix, int may_lack, int* found,
                                      gsf_nn_weights* weights) {
    static const char* const suffixes[] = {".safetensors", ".pth", ".pth.tar", ".safetensors"}; // again, for the report
    gsf_result result = GSF_OK;
    char name[256];
    *found = 0;
    for (size_t i = 0; i < (may_lack ? 3 : 4) && !result && !*found; i++) {
        if ((size_t)snprintf(name, sizeof name, "%s%s", prefix, suffixes[i]) >= sizeof name)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: a prefix of %zu bytes", folder, strlen(prefix));
        result = gsf__nn_open_named(ctx, folder, name, i < 3, found, weights);
    }
    return result;
}

// Without a prefix: the folder's only index, else its only file; if folders cannot be listed, the usual file names.
static gsf_result gsf__nn_open_folder(gsf_context* ctx, const char* folder, gsf_nn_weights* weights) {
    static const char* const suffixes[] = {".safetensors.index.json", ".safetensors", ".pth"};
    static const char* const usual[] = {"diffusion_pytorch_model", "model"};
    gsf_result result = GSF_OK;
    int found = 0;
    if (!gsf__io_is_plain(ctx) || gsf__nn_look_at_path(folder) == GSF__NN_UNKNOWN) {
        for (size_t i = 0; i < GSF__COUNT(usual) && result == GSF_OK && !found; i++)
            result = gsf__nn_open_prefix(ctx, folder, usual[i], 1, &found, weights);
    }
    for (size_t i = 0; i < GSF__COUNT(suffixes) && result == GSF_OK && !found; i++) {
        if (!gsf__io_is_plain(ctx)) break;
        gsf__nn_listing listing;
        memset(&listing, 0, sizeof listing);
        listing.folder = folder;
        listing.suffix = suffixes[i];
        result = gsf__nn_list_folder(ctx, &listing);
        if (result == GSF_OK && listing.found.size) {
            if (i == 0) listing.found.data[listing.found.size - strlen(".index.json")] = 0;
            result = gsf__nn_open_named(ctx, folder, listing.found.data, 0, &found, weights);
        }
        gsf_destroy_buffer(ctx, &listing.found);
    }
    if (result == GSF_OK && !found)
        return gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s: contains no .safetensors or .pth file", folder);
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

static int gsf__nn_names_weights(const char* path) {
    static const char* const suffixes[] = {".safetensors", ".pth", ".pth.tar", ".pt", ".bin"};
    int found = 0;
    for (size_t i = 0; i < GSF__COUNT(suffixes); i++) found |= gsf__nn_ends_in(path, suffixes[i]);
    return found;
}

GSF_API gsf_result gsf_nn_load_weights(gsf_context* ctx, const char* path, const char* prefix, gsf_nn_weights* out) {
    gsf_result result = gsf__nn_begin_weights(ctx, path, out);
    if (result != GSF_OK) return result;
    const gsf__nn_path_kind kind = gsf__io_is_plain(ctx) ? gsf__nn_look_at_path(path) : GSF__NN_UNKNOWN;
    int found;
    if (kind != GSF__NN_IS_FOLDER && gsf__nn_ends_in(path, ".index.json")) {
        result = gsf__nn_open_index_file(ctx, path, out);
    } else if (kind == GSF__NN_IS_FILE || (kind == GSF__NN_UNKNOWN && gsf__nn_names_weights(path))) {
        result = gsf__nn_add_file(ctx, path, out);
        if (result == GSF_OK) result = gsf__nn_sort_names(ctx, out);
    } else if (prefix) {
        result = gsf__nn_open_prefix(ctx, path, prefix, 0, &found, out);
    } else {
        result = gsf__nn_open_folder(ctx, path, out);
    }
    if (result != GSF_OK) gsf_nn_destroy_weights(ctx, out);
    return result;
}

GSF_API gsf_result gsf_nn_parse_weights(gsf_context* ctx, const char* name, const void* data, size_t size,
                                        gsf_nn_weights* out) {
    gsf_result result = gsf__nn_begin_weights(ctx, name, out);
    if (result == GSF_OK) result = gsf__nn_add_bytes(ctx, name, (const unsigned char*)data, size, GSF__NN_BORROWED, out);
    if (result == GSF_OK) result = gsf__nn_sort_names(ctx, out);
    if (result != GSF_OK) gsf_nn_destroy_weights(ctx, out);
    return result;
}

GSF_API void gsf_nn_destroy_weights(gsf_context* ctx, gsf_nn_weights* weights) {
    gsf__nn_files* files = (gsf__nn_files*)weights->files;
    for (size_t i = 0; files && i < files->count; i++) {
        gsf__nn_release(ctx, files->files[i].data, files->files[i].size, files->files[i].holder);
        gsf_free(ctx, files->files[i].names);
        gsf_free(ctx, files->files[i].copies);
    }
    if (files) gsf_free(ctx, files->files);
    gsf_free(ctx, files);
    gsf_free(ctx, weights->tensors);
    memset(weights, 0, sizeof *weights);
}

GSF_API const gsf_nn_tensor* gsf_nn_find_tensor(const gsf_nn_weights* weights, const char* name) {
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

static gsf_result gsf__nn_check_saved(gsf_context* ctx, const gsf_nn_tensor* tensor) {
    const char* name = tensor->name ? tensor->name : "";
    size_t left = strlen(name);
    int64_t count = 1;
    for (const char* p = name; left;) {
        const size_t step = gsf__utf8_size(p, left);
        if (!step) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "tensor %s: name is not UTF-8", gsf__nn_show(name).text);
        p += step;
        left -= step;
    }
    int ok = tensor->name && strcmp(name, "__metadata__") != 0 && gsf_nn_get_dtype_size(tensor->dtype) != 0 &&
             tensor->rank >= 0 && tensor->rank <= GSF_NN_MAX_RANK;
    for (int32_t i = 0; ok && i < tensor->rank; i++) {
        ok = tensor->shape[i] >= 0 && (tensor->shape[i] == 0 || count <= INT64_MAX / tensor->shape[i]);
        if (ok) count *= tensor->shape[i];
    }
    ok = ok && count == tensor->count && (count == 0 || tensor->data) &&
         (uint64_t)count <= SIZE_MAX / 2 / gsf_nn_get_dtype_size(tensor->dtype);
    if (ok) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "tensor %s: name, dtype, shape, count and data are inconsistent",
                    gsf__nn_show(name).text);
}

static int gsf__nn_compare_saved(const void* a, const void* b) { // wide types first, so that all tensors stay aligned
    const gsf_nn_tensor *x = *(const gsf_nn_tensor* const*)a, *y = *(const gsf_nn_tensor* const*)b;
    const size_t p = gsf_nn_get_dtype_size(x->dtype), q = gsf_nn_get_dtype_size(y->dtype);
    return p != q ? (p > q ? -1 : 1) : strcmp(x->name, y->name);
}

static int gsf__nn_compare_saved_names(const void* a, const void* b) {
    return strcmp((*(const gsf_nn_tensor* const*)a)->name, (*(const gsf_nn_tensor* const*)b)->name);
}

static gsf_result gsf__nn_format_header(gsf_context* ctx, const gsf_nn_tensor* const* order, size_t count,
                                        gsf_buffer* out) {
    size_t begin = 0;
    gsf_append_bytes(ctx, out, "        {", 9); // the spaces are overwritten with the length
    for (size_t i = 0; i < count; i++) {
        const gsf_nn_tensor* t = order[i];
        const size_t bytes = (size_t)gsf__nn_bytes(t);
        if (bytes > SIZE_MAX / 2 - begin) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "the tensors' sizes overflow");
        if (i) gsf_append_bytes(ctx, out, ",", 1);
        gsf_append_json_string(ctx, out, t->name);
        gsf_append_text(ctx, out, ":{\"dtype\":\"%s\",\"shape\":[", gsf__nn_dtype_name(t->dtype));
        for (int32_t k = 0; k < t->rank; k++) gsf_append_text(ctx, out, "%s%lld", k ? "," : "", (long long)t->shape[k]);
        gsf_append_text(ctx, out, "],\"data_offsets\":[%zu,%zu]}", begin, begin + bytes);
        begin += bytes;
    }
    gsf_append_bytes(ctx, out, "}", 1);
    gsf_append_bytes(ctx, out, "       ", (8 - out->size % 8) % 8);
    if (out->failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__store_le(out->data, out->size - GSF__NN_FILE_HEAD, GSF__NN_FILE_HEAD);
    return gsf__reserve(ctx, (void**)&out->data, &out->capacity, out->size, out->size + begin + 1, 1);
}

GSF_API gsf_result gsf_nn_save_tensors(gsf_context* ctx, const char* path, const gsf_nn_tensor* tensors, size_t count) {
    gsf_buffer out;
    memset(&out, 0, sizeof out);
    for (size_t i = 0; i < count; i++) GSF__TRY(gsf__nn_check_saved(ctx, &tensors[i]));
    const gsf_nn_tensor** order = (const gsf_nn_tensor**)gsf_alloc(ctx, count, sizeof *order);
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
        gsf_append_bytes(ctx, &out, (const char*)order[i]->data, (size_t)gsf__nn_bytes(order[i]));
    if (result == GSF_OK) result = out.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, out.data, out.size);
    gsf_destroy_buffer(ctx, &out);
    gsf_free(ctx, (void*)order);
    return result;
}

// ---- for the networks: taking tensors one by one, and detecting tensors left over

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

// "[2, 3, 64]"; a negative size, which matches any, is printed as "?".
static void gsf__nn_print_shape(int32_t rank, const int64_t* shape, char* out, size_t room) {
    size_t at = (size_t)snprintf(out, room, "[");
    for (int32_t i = 0; i < rank && at < room; i++) {
        const char* comma = i ? ", " : "";
        at += (size_t)(shape[i] < 0 ? snprintf(out + at, room - at, "%s?", comma)
                                    : snprintf(out + at, room - at, "%s%lld", comma, (long long)shape[i]));
    }
    if (at < room) snprintf(out + at, room - at, "]");
}

static gsf_result gsf__nn_check_taken(const gsf__nn_loader* loader, const gsf_nn_tensor* t, int32_t rank,
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
                        loader->weights->name, gsf__nn_show(t->name).text, gsf__nn_dtype_name(t->dtype));
    return GSF_OK;
}

static gsf_result gsf__nn_take(gsf__nn_loader* loader, const char* name, const gsf_nn_tensor** out, int32_t rank,
                               const int64_t* shape) {
    *out = NULL;
    const gsf_nn_tensor* found = gsf_nn_find_tensor(loader->weights, name);
    if (!found)
        return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensor %s is missing", loader->weights->name,
                        gsf__nn_show(name).text);
    loader->taken[found - loader->weights->tensors] = 1;
    GSF__TRY(gsf__nn_check_taken(loader, found, rank, shape));
    *out = found;
    return GSF_OK;
}

// Finds the tensor of that name (printf style), which must be F32, BF16 or F16 and have exactly this shape; a negative
// size matches any.
GSF_PRINTF(5, 6)
GSF__SHARED gsf_result gsf__nn_need(gsf__nn_loader* loader, const gsf_nn_tensor** out, int32_t rank,
                                    const int64_t* shape, const char* format, ...) {
    char name[256];
    va_list args;
    va_start(args, format);
    vsnprintf(name, sizeof name, format, args);
    va_end(args);
    return gsf__nn_take(loader, name, out, rank, shape);
}

// Marks all tensors whose names start with `prefix` as taken: parts of a file that the caller does not use.
GSF__SHARED void gsf__nn_ignore(gsf__nn_loader* loader, const char* prefix) {
    for (size_t i = 0; i < loader->weights->tensor_count; i++)
        if (strncmp(loader->weights->tensors[i].name, prefix, strlen(prefix)) == 0) loader->taken[i] = 1;
}

// Frees the loader. If `result` is GSF_OK but tensors are left over, fails and names the first few; else returns it.
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

// ---- for the networks: config.json. A null value counts as absent, as diffusers writes it.

typedef struct gsf__nn_config {
    gsf_context* ctx;
    gsf_json json;
    const gsf_json_value* root; // the object whose keys are read; NULL: all keys are absent
} gsf__nn_config;

static gsf_result gsf__nn_check_config(gsf__nn_config* config) {
    config->root = &config->json.values[0];
    if (config->root->type == GSF_JSON_OBJECT) return GSF_OK;
    const gsf_result result = gsf_fail(config->ctx, GSF_ERROR_FORMAT, "%s:0: not an object", config->json.name);
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

GSF__SHARED void gsf__nn_close_config(gsf__nn_config* config) { gsf_destroy_json(config->ctx, &config->json); }

static const gsf_json_value* gsf__nn_config_find(const gsf__nn_config* config, const char* key) {
    const gsf_json_value* value = gsf_find_json_member(&config->json, config->root, key);
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

// Integers, |low| and |high| up to 2^53. Here and below, the variant with `fallback` allows the key to be absent.
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

// The flag `value` of any object; null counts as absent.
static gsf_result gsf__nn_config_flag(const gsf__nn_config* config, const gsf_json_value* value, const char* key,
                                      int fallback, int* out) {
    *out = fallback;
    if (!value || value->type == GSF_JSON_NULL) return GSF_OK;
    if (value->type != GSF_JSON_TRUE && value->type != GSF_JSON_FALSE)
        return gsf__nn_config_fail(config, value, key, "true or false");
    *out = value->type == GSF_JSON_TRUE;
    return GSF_OK;
}

GSF__SHARED gsf_result gsf__nn_config_bool_or(const gsf__nn_config* config, const char* key, int fallback, int* out) {
    return gsf__nn_config_flag(config, gsf__nn_config_find(config, key), key, fallback, out);
}

// *out points into the config or to `fallback`; if `fallback` is NULL, the key is required.
GSF__SHARED gsf_result gsf__nn_config_string(const gsf__nn_config* config, const char* key, const char* fallback,
                                             const char** out) {
    const gsf_json_value* value = gsf__nn_config_find(config, key);
    *out = fallback;
    if (!value && fallback) return GSF_OK;
    if (!value || value->type != GSF_JSON_STRING) return gsf__nn_config_fail(config, value, key, "a string");
    *out = value->string;
    return GSF_OK;
}

// The object under `key` as a config that is valid as long as the whole; if there is none, all its keys are absent.
static gsf_result gsf__nn_config_part(const gsf__nn_config* config, const char* key, gsf__nn_config* part) {
    *part = *config;
    part->root = gsf__nn_config_find(config, key);
    if (!part->root || part->root->type == GSF_JSON_OBJECT) return GSF_OK;
    return gsf__nn_config_fail(config, part->root, key, "an object");
}

// Reads between 1 and `room` integers.
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

// ---- for the networks: a config.json as a table of keys

// Reads FOLDER/NAME; with `may_lack` a missing file counts as an empty object. gsf__nn_close_config accepts
// the result of a failed call.
GSF__SHARED gsf_result gsf__nn_open_config(gsf_context* ctx, const char* folder, const char* name, int may_lack,
                                           gsf__nn_config* out) {
    gsf_buffer path;
    void* data = NULL;
    size_t size = 0;
    memset(out, 0, sizeof *out);
    out->ctx = ctx;
    gsf_result result = gsf__nn_join(ctx, folder, name, &path);
    if (!result && may_lack) result = gsf__nn_read_if_there(ctx, path.data, &data, &size);
    else if (!result) result = gsf_read_file(ctx, path.data, &data, &size);
    if (!result && !data && may_lack) result = gsf__nn_parse_config(ctx, path.data, "{}", 2, out);
    else if (!result) result = gsf__nn_parse_config(ctx, path.data, (const char*)data, size, out);
    gsf_free(ctx, data);
    gsf_destroy_buffer(ctx, &path);
    return result;
}

typedef enum gsf__nn_key_kind {
    GSF__NN_INT, GSF__NN_NEEDED_INT, GSF__NN_REAL, GSF__NN_FLAG, GSF__NN_FIXED_FLAG, GSF__NN_WORD, GSF__NN_ACTIVATION,
    GSF__NN_ABSENT,
} gsf__nn_key_kind;

typedef struct gsf__nn_key {
    const char* key;
    gsf__nn_key_kind kind;
    void* to;                   // `size` bytes: int32_t or int64_t, float or double, int
    size_t size;
    double fallback, low, high; // a fixed flag must equal `low`
    const char *word, *words;   // default word (NULL: the key is required); allowed words: "a|b|c"
} gsf__nn_key;

#define GSF__KEY_INT(key, to, low, high) {key, GSF__NN_NEEDED_INT, &(to), sizeof(to), 0.0, low, high, NULL, NULL}
#define GSF__KEY_INT_OR(key, to, usual, low, high) {key, GSF__NN_INT, &(to), sizeof(to), usual, low, high, NULL, NULL}
#define GSF__KEY_REAL_OR(key, to, usual, low, high) {key, GSF__NN_REAL, &(to), sizeof(to), usual, low, high, NULL, NULL}
#define GSF__KEY_FLAG_OR(key, to, usual) {key, GSF__NN_FLAG, &(to), sizeof(to), usual, 0.0, 0.0, NULL, NULL}
#define GSF__KEY_WORD_OR(key, to, usual, words) {key, GSF__NN_WORD, &(to), sizeof(to), 0.0, 0.0, 0.0, usual, words}
#define GSF__KEY_ACTIVATION_OR(key, to, usual) {key, GSF__NN_ACTIVATION, &(to), sizeof(to), 0.0, 0.0, 0.0, usual, NULL}
// For settings that the code supports with one value only.
#define GSF__KEY_FLAG_IS(key, usual, must) {key, GSF__NN_FIXED_FLAG, NULL, 0, usual, must, 0.0, NULL, NULL}
#define GSF__KEY_WORD_IS(key, usual, must) {key, GSF__NN_WORD, NULL, 0, 0.0, 0.0, 0.0, usual, must}
#define GSF__KEY_ABSENT(key) {key, GSF__NN_ABSENT, NULL, 0, 0.0, 0.0, 0.0, NULL, NULL}

// The index of the key's word among k->words.
static gsf_result gsf__nn_config_word(const gsf__nn_config* config, const gsf__nn_key* k, const char* words, int* out) {
    const char* text;
    GSF__TRY(gsf__nn_config_string(config, k->key, k->word, &text));
    const size_t size = strlen(text);
    *out = 0;
    for (const char* w = words; *w; w += strcspn(w, "|"), w += *w == '|', ++*out)
        if (strcspn(w, "|") == size && memcmp(w, text, size) == 0) return GSF_OK;
    return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: %s is %s, not %s", config->json.name, k->key,
                    gsf__nn_show(text).text, words);
}

static gsf_result gsf__nn_config_flag_is(const gsf__nn_config* config, const gsf__nn_key* k) {
    const int must = k->low != 0.0;
    int flag;
    GSF__TRY(gsf__nn_config_bool_or(config, k->key, k->fallback != 0.0, &flag));
    if (flag == must) return GSF_OK;
    return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: %s is not %s", config->json.name, k->key,
                    must ? "true" : "false");
}

static void gsf__nn_store_int(const gsf__nn_key* k, int64_t value) { // int32_t and enums, or int64_t
    const int32_t narrow = (int32_t)value;
    if (k->size == sizeof narrow) memcpy(k->to, &narrow, sizeof narrow);
    if (k->size == sizeof value) memcpy(k->to, &value, sizeof value);
}

static void gsf__nn_store_real(const gsf__nn_key* k, double value) {
    const float narrow = (float)value;
    if (k->size == sizeof narrow) memcpy(k->to, &narrow, sizeof narrow);
    else memcpy(k->to, &value, sizeof value);
}

static gsf_result gsf__nn_config_read_key(const gsf__nn_config* config, const gsf__nn_key* k) {
    static const gsf__nn_activation activations[] = {GSF__NN_GELU, GSF__NN_GELU_TANH, GSF__NN_GELU_TANH,
                                                    GSF__NN_RELU, GSF__NN_SILU, GSF__NN_SILU};
    const int64_t low = (int64_t)k->low, high = (int64_t)k->high;
    int64_t whole = 0;
    double real;
    int flag = 0;
    switch (k->kind) {
        case GSF__NN_INT: GSF__TRY(gsf__nn_config_int_or(config, k->key, (int64_t)k->fallback, low, high, &whole)); break;
        case GSF__NN_NEEDED_INT: GSF__TRY(gsf__nn_config_int(config, k->key, low, high, &whole)); break;
        case GSF__NN_REAL:
            GSF__TRY(gsf__nn_config_number_or(config, k->key, k->fallback, k->low, k->high, &real));
            gsf__nn_store_real(k, real);
            return GSF_OK;
        case GSF__NN_FLAG: GSF__TRY(gsf__nn_config_bool_or(config, k->key, k->fallback != 0.0, &flag)); break;
        case GSF__NN_FIXED_FLAG: return gsf__nn_config_flag_is(config, k);
        case GSF__NN_WORD: GSF__TRY(gsf__nn_config_word(config, k, k->words, &flag)); break;
        case GSF__NN_ACTIVATION:
            GSF__TRY(gsf__nn_config_word(config, k, "gelu|gelu_new|gelu_pytorch_tanh|relu|silu|swish", &flag));
            flag = (int)activations[flag];
            break;
        case GSF__NN_ABSENT:
            if (!gsf__nn_config_find(config, k->key)) return GSF_OK;
            return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s: %s is not null", config->json.name, k->key);
    }
    gsf__nn_store_int(k, flag ? flag : whole);
    return GSF_OK;
}

static gsf_result gsf__nn_config_read(const gsf__nn_config* config, const gsf__nn_key* keys, size_t count) {
    for (size_t i = 0; i < count; i++) GSF__TRY(gsf__nn_config_read_key(config, &keys[i]));
    return GSF_OK;
}

// ---- >>nn vector: additions to the vector vocabulary of >>lanes ----------------------------

// Prefetches a cache line; `at` may lie outside of the array.
GSF__SHARED void gsf__nn_prefetch(const float* at) {
#if GSF__X86
    _mm_prefetch((const char*)at, _MM_HINT_T0);
#endif
    (void)at;
}

// For the rows of a tile, in named variables: gcc would keep an array in memory.
#define GSF__SIX(X) X(0) X(1) X(2) X(3) X(4) X(5)

#define gsf__v_put GSF__V(gsf__v_put)               // stores; `stream` bypasses the caches and needs an aligned address
#define gsf__v_turn_pairs GSF__V(gsf__v_turn_pairs) // (a c - b s, b c + a s) for each pair of lanes (a, b)
#define gsf__v_hadamard GSF__V(gsf__v_hadamard)     // of each block of 1, 2, 4 ... lanes, unscaled
#define gsf__vi_max GSF__V(gsf__vi_max)
#define gsf__vi_largest GSF__V(gsf__vi_largest)     // over the lanes

#if GSF__X86

GSF__INLINE_AVX2 void gsf__v_put_avx2(float* y, __m256 v, int stream) {
    if (stream) _mm256_stream_ps(y, v);
    else _mm256_storeu_ps(y, v);
}

GSF__INLINE_AVX512 void gsf__v_put_avx512(float* y, __m512 v, int stream) {
    if (stream) _mm512_stream_ps(y, v);
    else _mm512_storeu_ps(y, v);
}


GSF__INLINE_AVX2 __m256 gsf__v_turn_pairs_avx2(__m256 v, __m256 cos, __m256 sin) {
    return _mm256_fmaddsub_ps(v, cos, _mm256_permute_ps(v, 0xb1) * sin);
}

GSF__INLINE_AVX512 __m512 gsf__v_turn_pairs_avx512(__m512 v, __m512 cos, __m512 sin) {
    return _mm512_fmaddsub_ps(v, cos, _mm512_permute_ps(v, 0xb1) * sin);
}

// Adds to each value its partner, or (upper half) subtracts the value from it. The FMAs are exact here, so the result
// is bit-identical to the scalar kernel's.
GSF__INLINE_AVX2 __m256 gsf__v_hadamard_avx2(__m256 v, int64_t block) {
    if (block > 1) v = _mm256_fmadd_ps(v, _mm256_setr_ps(1, -1, 1, -1, 1, -1, 1, -1), _mm256_permute_ps(v, 0xb1));
    if (block > 2) v = _mm256_fmadd_ps(v, _mm256_setr_ps(1, 1, -1, -1, 1, 1, -1, -1), _mm256_permute_ps(v, 0x4e));
    if (block > 4) v = _mm256_fmadd_ps(v, _mm256_setr_ps(1, 1, 1, 1, -1, -1, -1, -1), _mm256_permute2f128_ps(v, v, 1));
    return v;
}

GSF__INLINE_AVX512 __m512 gsf__v_hadamard_avx512(__m512 v, int64_t block) {
    const __m512 one = _mm512_set1_ps(1.0f), less = _mm512_set1_ps(-1.0f);
    if (block > 1) v = _mm512_fmadd_ps(v, _mm512_mask_blend_ps(0xaaaa, one, less), _mm512_permute_ps(v, 0xb1));
    if (block > 2) v = _mm512_fmadd_ps(v, _mm512_mask_blend_ps(0xcccc, one, less), _mm512_permute_ps(v, 0x4e));
    if (block > 4) v = _mm512_fmadd_ps(v, _mm512_mask_blend_ps(0xf0f0, one, less), _mm512_shuffle_f32x4(v, v, 0xb1));
    if (block > 8) v = _mm512_fmadd_ps(v, _mm512_mask_blend_ps(0xff00, one, less), _mm512_shuffle_f32x4(v, v, 0x4e));
    return v;
}

GSF__INLINE_AVX2 __m256i gsf__vi_max_avx2(__m256i a, __m256i b) { return _mm256_max_epi32(a, b); }
GSF__INLINE_AVX512 __m512i gsf__vi_max_avx512(__m512i a, __m512i b) { return _mm512_max_epi32(a, b); }

GSF__INLINE_AVX2 int32_t gsf__vi_largest_avx2(__m256i v) {
    __m128i s = _mm_max_epi32(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
    s = _mm_max_epi32(s, _mm_shuffle_epi32(s, 0x4e));
    return _mm_cvtsi128_si32(_mm_max_epi32(s, _mm_shuffle_epi32(s, 0xb1)));
}

GSF__INLINE_AVX512 int32_t gsf__vi_largest_avx512(__m512i v) {
    return gsf__vi_largest_avx2(_mm256_max_epi32(_mm512_castsi512_si256(v), _mm512_extracti32x8_epi32(v, 1)));
}

// Mask of the lanes below `left` (clamped to 8) for _mm256_maskload_ps and _mm256_maskstore_ps.
GSF__INLINE_AVX2 __m256i gsf__nn_mask8(int64_t left) {
    return _mm256_cmpgt_epi32(_mm256_set1_epi32(left < 8 ? (int)left : 8), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
}

GSF__INLINE_AVX512 __mmask16 gsf__nn_mask16(int64_t left) { return gsf__vm_first_avx512((size_t)left); } // left >= 0

enum { GSF__NN_WHOLE16 = 0xffff }; // all lanes

GSF__INLINE_AVX512 void gsf__nn_store16(float* y, __mmask16 mask, __m512 v) { // a masked store is several times slower
    if (mask == GSF__NN_WHOLE16) _mm512_storeu_ps(y, v);
    else _mm512_mask_storeu_ps(y, mask, v);
}

GSF__INLINE_AVX512 __m256 gsf__nn_fold16(__m512 v) { return _mm512_castps512_ps256(v) + _mm512_extractf32x8_ps(v, 1); }

// to[j to_ld + i] = m[i][j]
GSF__INLINE_AVX2 void gsf__nn_store_columns(__m256 m[8], float* to, int64_t to_ld) {
    gsf__v_transpose_avx2(m);
#define GSF_X(r) _mm256_storeu_ps(to + (r) * to_ld, m[r]);
    GSF_X(0) GSF_X(1) GSF_X(2) GSF_X(3) GSF_X(4) GSF_X(5) GSF_X(6) GSF_X(7)
#undef GSF_X
}

// to[j to_ld + i] = (from[i ld + j] - center[j]) factor for i, j < 8
GSF__INLINE_AVX2 void gsf__nn_transpose8(const float* from, int64_t ld, __m256 center, __m256 factor, float* to,
                                         int64_t to_ld) {
#define GSF_X(r) (_mm256_loadu_ps(from + (r) * ld) - center) * factor
    __m256 m[8] = {GSF_X(0), GSF_X(1), GSF_X(2), GSF_X(3), GSF_X(4), GSF_X(5), GSF_X(6), GSF_X(7)};
#undef GSF_X
    gsf__nn_store_columns(m, to, to_ld);
}

// Pairs of bfloat16 are held in float lanes.

GSF__INLINE_BF16 __m512 gsf__nn_add_pairs(__m512 sum, __m512 a, __m512 b) { // sum + a[0] b[0] + a[1] b[1]
    return _mm512_dpbf16_ps(sum, (__m512bh)_mm512_castps_si512(a), (__m512bh)_mm512_castps_si512(b));
}

GSF__INLINE_BF16 __m256i gsf__nn_round_bf16(__m512 v) { return (__m256i)_mm512_cvtneps_pbh(v); }

#endif // GSF__X86

// ---- >>nn activations -----------------------------------------------------------

// GELU is max(x, 0) - z q with z = |x| and q = exp(-z^2/2) R(z), the tail of the normal distribution beyond z. R varies
// slowly and is computed as t P(t - 1/2) with t = 3.5 / (z + 3.5): least-squares coefficients, refitted until the
// relative errors for z up to 13.25 were level, 4e-8. Beyond 13.19 the power of 2 underflows float, so q is 0.
static const float gsf__nn_gelu_tail[10] = {0.212690309f, 0.323178142f, 0.360485673f, 0.2652632f, 0.0795778036f,
                                            -0.0593477674f, -0.0581759363f, 0.0180590637f, 0.0315735899f, -0.016954517f};

static float gsf__nn_gelu_ref(float x) {
    const float z = fabsf(x) > 13.2f ? 13.2f : fabsf(x), t = 3.5f / (z + 3.5f), s = t - 0.5f;
    const double u = -0.7213475204444817 * (double)z * (double)z, n = (u + 6755399441055744.0) - 6755399441055744.0;
    if (n < -125.5) return x > 0.0f ? x : 0.0f;
    const float f = (float)(u - n);
    float tail = gsf__nn_gelu_tail[9];
    for (int i = 8; i >= 0; i--) tail = tail * s + gsf__nn_gelu_tail[i];
    const float power = ((((((1.535336188319500e-4f * f + 1.339887440266574e-3f) * f + 9.618437357674640e-3f) * f +
                            5.550332471162809e-2f) * f + 2.402264791363012e-1f) * f + 6.931472028550421e-1f) * f + 1.0f);
    const uint32_t bits = (uint32_t)((x == x ? (int)n : 0) + 127) << 23;
    float two_n;
    memcpy(&two_n, &bits, sizeof two_n);
    return (x < 0.0f ? 0.0f : x) - z * (power * two_n * t * tail);
}

static float gsf__nn_activation_ref(gsf__nn_activation activation, float x) {
    switch (activation) {
        case GSF__NN_LINEAR: return x;
        case GSF__NN_GELU_TANH: { // x/2 (1 + tanh(u)) = x / (1 + exp(-2u))
            if (x < -12.0f) return -0.0f * (x == x); // the limit to within float's resolution, and avoids inf * 0
            const float u = 0.7978845608028654f * (x + 0.044715f * x * x * x);
            return x / (1.0f + expf(-2.0f * u));
        }
        case GSF__NN_SILU: return x < -104.0f ? -0.0f : x / (1.0f + expf(-x));
        case GSF__NN_GELU: return gsf__nn_gelu_ref(x);
        case GSF__NN_RELU: return x < 0.0f ? 0.0f : x;
        case GSF__NN_QUICK_GELU: return x < -61.0f ? -0.0f : x / (1.0f + expf(-1.702f * x));
    }
    return x;
}

// Results of 32 MiB and more bypass the caches (`stream`): lines that are fully overwritten need not be read first.
enum { GSF__NN_STREAM = 1 << 23 }; // values

// Whether to stream the results to y; the pieces of work are multiples of `row`.
static int gsf__nn_streams(const float* x, const float* y, int64_t count, int64_t row) {
    return x != y && count >= GSF__NN_STREAM && row % 16 == 0 && (uintptr_t)y % 64 == 0;
}

typedef struct gsf__activation_kernels { // y may be x in both
    void (*activate)(gsf__nn_activation activation, const float* x, int64_t count, float* y, int stream);
    void (*softmax)(const float* x, int64_t count, float scale, float* y);
} gsf__activation_kernels;

static void gsf__activate_scalar(gsf__nn_activation activation, const float* x, int64_t count, float* y, int stream) {
    (void)stream;
    for (int64_t i = 0; i < count; i++) y[i] = gsf__nn_activation_ref(activation, x[i]);
}

static void gsf__softmax_scalar(const float* x, int64_t count, float scale, float* y) {
    float top = -FLT_MAX;
    double sum = 0.0;
    for (int64_t i = 0; i < count; i++)
        if (scale * x[i] > top) top = scale * x[i];
    for (int64_t i = 0; i < count; i++) sum += (double)(y[i] = expf(scale * x[i] - top));
    const float inverse = (float)(1.0 / sum);
    for (int64_t i = 0; i < count; i++) y[i] *= inverse;
}

GSF__SHARED void gsf__nn_end_stream(int stream) { // before other threads may read the results
#if GSF__X86
    if (stream) _mm_sfence();
#endif
    (void)stream;
}

#define gsf__v_gelu_tail GSF__V(gsf__v_gelu_tail)
#define gsf__v_gelu_limit GSF__V(gsf__v_gelu_limit)
#define gsf__v_gelu GSF__V(gsf__v_gelu)
#define gsf__v_activate GSF__V(gsf__v_activate)

#define GSF__KERNELS "gsfixer_nn.h"
#define GSF__KERNELS_ACTIVATIONS
#define GSF__KERNELS_AVX512
#include "gsfixer.h" // compiles what follows, once per instruction set
#undef GSF__KERNELS_ACTIVATIONS

#endif // GSF__ISA
#ifdef GSF__KERNELS_ACTIVATIONS
#if GSF__LANES > 1 // at one lane: the reference above

// q of gsf__nn_gelu_ref for z in [0, 13.2]; power: exp(-z^2/2)
GSF__V_INLINE gsf__vf gsf__v_gelu_tail(gsf__vf z, gsf__vf* power) {
    const gsf__v_exp2_terms terms = gsf__v_exp2_of(0);
    const gsf__vf half_log2_e = gsf__v_set(-0.72134752f), k = gsf__v_set(3.5f);
    const gsf__vf t = k / (z + k), s = t - gsf__v_set(0.5f), square = z * z;
    const gsf__vf rounded = gsf__v_madd(square, half_log2_e, terms.rounder), n = rounded - terms.rounder;
    // the rounding errors of the square and of the factor
    const gsf__vf lost = gsf__v_msub(z, z, square) * half_log2_e;
    const gsf__vf low = gsf__v_madd(square, gsf__v_set(-9.62981495e-9f), lost);
    *power = gsf__v_power(&terms, rounded, gsf__v_msub(square, half_log2_e, n) + low);
    gsf__vf tail = gsf__v_set(gsf__nn_gelu_tail[9]);
    for (int i = 8; i >= 0; i--) tail = gsf__v_madd(tail, s, gsf__v_set(gsf__nn_gelu_tail[i]));
    return *power * (t * tail);
}

GSF__V_INLINE gsf__vf gsf__v_gelu_limit(gsf__vf x) { // |x| up to where q is 0; a NaN stays a NaN, as below
    return gsf__v_min(gsf__v_set(13.2f), gsf__v_abs(x));
}

GSF__V_INLINE gsf__vf gsf__v_gelu(gsf__vf x) {
    gsf__vf power;
    const gsf__vf z = gsf__v_gelu_limit(x);
    return gsf__v_nmadd(z, gsf__v_gelu_tail(z, &power), gsf__v_max(gsf__v_set(0.0f), x));
}

// As gsf__nn_activation_ref, and -0, the limit, at -inf; a NaN stays a NaN.
// In loops pass `activation` as a compile-time constant.
GSF__V_INLINE gsf__vf gsf__v_activate(gsf__nn_activation activation, gsf__vf x) {
    const gsf__vf one = gsf__v_set(1.0f);
    if (activation == GSF__NN_GELU_TANH) { // x / (1 + 2^-(a x + b x^3)), a = 2 sqrt(2 / pi) log2 e, b = 0.044715 a
        x = gsf__v_max(gsf__v_set(-12.0f), x); // below, the power overflows to inf
        const gsf__vf slope = gsf__v_madd(x * x, gsf__v_set(-0.10294324f), gsf__v_set(-2.30220819f));
        return x / (one + gsf__v_exp2(x * slope));
    }
    if (activation == GSF__NN_SILU) {
        x = gsf__v_max(gsf__v_set(-100.0f), x);
        return x / (one + gsf__v_exp(gsf__v_set(0.0f) - x));
    }
    if (activation == GSF__NN_GELU) return gsf__v_gelu(x);
    if (activation == GSF__NN_RELU) return gsf__v_max(gsf__v_set(0.0f), x);
    if (activation == GSF__NN_QUICK_GELU) {
        x = gsf__v_max(gsf__v_set(-58.0f), x);
        return x / (one + gsf__v_exp(gsf__v_set(-1.702f) * x));
    }
    return x;
}

GSF__V_INLINE void GSF__V(gsf__activate_all)(gsf__nn_activation activation, const float* x, int64_t count, float* y,
                                             int stream) {
    int64_t i = 0;
    for (; i + GSF__LANES <= count; i += GSF__LANES)
        gsf__v_put(y + i, gsf__v_activate(activation, gsf__v_load(x + i)), stream);
    const size_t tail = (size_t)(count - i);
    if (tail) gsf__v_store_first(y + i, gsf__v_activate(activation, gsf__v_load_first(x + i, tail)), tail);
}

GSF__V_KERNEL void GSF__V(gsf__activate)(gsf__nn_activation activation, const float* x, int64_t count, float* y,
                                         int stream) {
#define GSF_X(kind)                                                          \
    case kind:                                                               \
        if (stream) GSF__V(gsf__activate_all)(kind, x, count, y, 1);         \
        else GSF__V(gsf__activate_all)(kind, x, count, y, 0);                \
        break;
    switch (activation) {
        GSF_X(GSF__NN_LINEAR)
        GSF_X(GSF__NN_GELU_TANH)
        GSF_X(GSF__NN_SILU)
        GSF_X(GSF__NN_GELU)
        GSF_X(GSF__NN_RELU)
        GSF_X(GSF__NN_QUICK_GELU)
    }
#undef GSF_X
    gsf__nn_end_stream(stream);
}

GSF__V_KERNEL void GSF__V(gsf__softmax)(const float* x, int64_t count, float scale, float* y) {
    const gsf__v_exp2_terms terms = gsf__v_exp2_of(1);
    const gsf__vf factor = gsf__v_set(scale * 1.44269504f), lowest = gsf__v_set(-FLT_MAX); // base 2 instead of e
    const int64_t whole = count / GSF__LANES * GSF__LANES;
    const size_t left = (size_t)(count - whole);
    const gsf__vm first = gsf__vm_first(left);
    const gsf__vf tail = gsf__v_load_first(x + whole, left);
    gsf__vf top0 = gsf__v_max(gsf__v_select(first, factor * tail, lowest), lowest), top1 = top0; // NaNs are ignored
    for (int64_t i = 0; i + GSF__LANES < whole; i += 2 * GSF__LANES) {
        top0 = gsf__v_max(factor * gsf__v_load(x + i), top0);
        top1 = gsf__v_max(factor * gsf__v_load(x + i + GSF__LANES), top1);
    }
    if (whole / GSF__LANES % 2) top0 = gsf__v_max(factor * gsf__v_load(x + whole - GSF__LANES), top0);
    const gsf__vf top = gsf__v_set(gsf__v_largest(gsf__v_max(top0, top1)));
    const gsf__vf last = gsf__v_keep(first, gsf__v_exp2_low(&terms, gsf__v_msub(tail, factor, top)));
    double sum = (double)gsf__v_sum(last);
    for (int64_t begin = 0; begin < whole; begin += 64 * GSF__LANES) { // sum short runs in float
        const int64_t end = gsf__least(begin + 64 * GSF__LANES, whole);
        gsf__vf part = gsf__v_set(0.0f);
        for (int64_t i = begin; i < end; i += GSF__LANES) {
            const gsf__vf power = gsf__v_exp2_low(&terms, gsf__v_msub(gsf__v_load(x + i), factor, top));
            gsf__v_store(y + i, power);
            part = part + power;
        }
        sum += (double)gsf__v_sum(part);
    }
    const gsf__vf inverse = gsf__v_set((float)(1.0 / sum));
    for (int64_t i = 0; i < whole; i += GSF__LANES) gsf__v_store(y + i, inverse * gsf__v_load(y + i));
    if (left) gsf__v_store_first(y + whole, inverse * last, left);
}

#endif
#endif // GSF__KERNELS_ACTIVATIONS
#ifndef GSF__ISA

static const gsf__activation_kernels* gsf__activation_kernels_of(gsf_cpu_level level) {
    static const gsf__activation_kernels scalar = {gsf__activate_scalar, gsf__softmax_scalar};
#if GSF__X86
    static const gsf__activation_kernels avx2 = {gsf__activate_avx2, gsf__softmax_avx2};
    static const gsf__activation_kernels avx512 = {gsf__activate_avx512, gsf__softmax_avx512};
    if (level >= GSF_CPU_AVX512) return &avx512;
    if (level >= GSF_CPU_AVX2) return &avx2;
#endif
    (void)level;
    return &scalar;
}

enum { GSF__NN_CHUNK = 1 << 15 }; // values per chunk of elementwise work

// Rows of `dim` values per chunk of elementwise work, and the number of chunks: independent of the number of workers.
static int64_t gsf__nn_chunk_rows(int64_t dim) { return dim < GSF__NN_CHUNK ? GSF__NN_CHUNK / (dim > 0 ? dim : 1) : 1; }
static size_t gsf__nn_chunks(int64_t count, int64_t per_chunk) { return (size_t)gsf__ceil_div(count, per_chunk); }

typedef struct gsf__finite_job {
    const float* x;
    int64_t count, part;
    int64_t first[64]; // per part; -1: none
} gsf__finite_job;

static void gsf__finite_part(void* arg, size_t index, int32_t worker) {
    gsf__finite_job* job = (gsf__finite_job*)arg;
    const int64_t begin = (int64_t)index * job->part, end = gsf__least(begin + job->part, job->count);
    (void)worker;
    job->first[index] = -1;
    for (int64_t i = begin; i < end; i++) {
        if (fabsf(job->x[i]) <= FLT_MAX) continue;
        job->first[index] = i;
        return;
    }
}

// Index of the first value that is NaN or infinite; -1 if there is none.
static int64_t gsf__nn_find_not_finite(gsf_context* ctx, const float* x, int64_t count) {
    gsf__finite_job job;
    job.x = x;
    job.count = count;
    job.part = gsf__ceil_div(count, (int64_t)GSF__COUNT(job.first));
    if (job.part < GSF__NN_CHUNK) job.part = GSF__NN_CHUNK;
    const size_t parts = gsf__nn_chunks(count, job.part);
    gsf__parallel_for(ctx, parts, gsf__finite_part, &job);
    for (size_t i = 0; i < parts; i++)
        if (job.first[i] >= 0) return job.first[i];
    return -1;
}

static int gsf__nn_tensor_is_finite(const gsf_nn_tensor* tensor) {
    float part[1024];
    for (int64_t i = 0; i < tensor->count; i += 1024) {
        const int64_t n = tensor->count - i < 1024 ? tensor->count - i : 1024;
        gsf_nn_convert_tensor(tensor, i, n, part);
        for (int64_t k = 0; k < n; k++)
            if (!(fabsf(part[k]) <= FLT_MAX)) return 0;
    }
    return 1;
}

// Called after each stage of network `name`: a non-finite value is an error. It names the first tensor with prefix
// `prefix` that contains a non-finite value, or else the stage.
static gsf_result gsf__nn_check_finite(gsf_context* ctx, const gsf_nn_weights* weights, const char* name,
                                       const char* prefix, const char* stage, const float* x, int64_t count) {
    const int64_t at = gsf__nn_find_not_finite(ctx, x, count);
    if (at < 0) return GSF_OK;
    for (size_t i = 0; i < weights->tensor_count; i++) {
        const gsf_nn_tensor* t = &weights->tensors[i];
        if (strncmp(t->name, prefix, strlen(prefix)) == 0 && !gsf__nn_tensor_is_finite(t))
            return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: tensor %s holds a NaN or an infinity", weights->name, t->name);
    }
    return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: %s gives %g (value %lld of %lld)", name, stage, (double)x[at],
                    (long long)at, (long long)count);
}

typedef struct gsf__activate_job {
    const gsf__activation_kernels* kernels;
    gsf__nn_activation activation;
    const float* x;
    float* y;
    int64_t rows, columns, chunk_rows;
    float scale;
    int stream;
} gsf__activate_job;

static void gsf__activate_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__activate_job* job = (const gsf__activate_job*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * GSF__NN_CHUNK;
    job->kernels->activate(job->activation, job->x + begin, gsf__least(GSF__NN_CHUNK, job->columns - begin),
                           job->y + begin, job->stream);
}

static void gsf__nn_activate(gsf_context* ctx, gsf__nn_activation activation, const float* x, int64_t count, float* y) {
    gsf__activate_job job;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__activation_kernels_of(ctx->cpu_level);
    job.activation = activation;
    job.x = x;
    job.y = y;
    job.columns = count;
    job.stream = gsf__nn_streams(x, y, count, GSF__NN_CHUNK);
    gsf__parallel_for(ctx, gsf__nn_chunks(count, GSF__NN_CHUNK), gsf__activate_chunk, &job);
}

static void gsf__softmax_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__activate_job* job = (const gsf__activate_job*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * job->chunk_rows, n = job->columns;
    for (int64_t r = begin; r < begin + job->chunk_rows && r < job->rows; r++)
        job->kernels->softmax(job->x + r * n, n, job->scale, job->y + r * n);
}

// Replaces each row of (rows, columns) by softmax(scale * row); y may be x.
GSF__SHARED void gsf__nn_softmax(gsf_context* ctx, const float* x, int64_t rows, int64_t columns, float scale,
                                 float* y) {
    gsf__activate_job job;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__activation_kernels_of(ctx->cpu_level);
    job.x = x;
    job.y = y;
    job.rows = rows;
    job.columns = columns;
    job.chunk_rows = gsf__nn_chunk_rows(columns);
    job.scale = scale;
    gsf__parallel_for(ctx, gsf__nn_chunks(rows, job.chunk_rows), gsf__softmax_chunk, &job);
}

// ---- >>nn norms -----------------------------------------------------------------

typedef struct gsf__moments { double mean, square; } gsf__moments; // square: sum of (x - mean)^2

typedef struct gsf__norm_vectors { const float *weight, *bias, *scale, *shift; } gsf__norm_vectors; // each may be NULL

typedef struct gsf__norm_job gsf__norm_job;
typedef struct gsf__norm_kernels {
    gsf__moments (*moments)(const float* x, int64_t count, int centre); // centre 0: the mean is taken as 0
    void (*row)(const gsf__norm_job* job, const float* x, float* y);
    void (*head)(const gsf__norm_job* job, float* x, const float* cos, const float* sin); // cos NULL: no rotation
    // y = weight (x - mean) inverse + bias; y may be x
    void (*affine)(const float* x, int64_t count, gsf__moments m, float inverse, float weight, float bias, float* y,
                   int stream);
} gsf__norm_kernels;

struct gsf__norm_job {
    const gsf__norm_kernels* kernels;
    const float *x, *cos, *sin;
    gsf__norm_vectors by;
    float* y;
    int64_t rows, dim, stride, chunk_rows, rope_first;
    int64_t group_size, part_size, parts, first_group; // for group norm: values per group and per part; parts per group
    gsf__moments* part_moments;
    int32_t heads;
    float eps;
    int centre; // 0: RMS norm
    int stream;
};

static float gsf__norm_inverse(gsf__moments m, int64_t count, float eps) {
    return (float)(1.0 / sqrt(m.square / (double)count + (double)eps));
}

static gsf__moments gsf__moments_scalar(const float* x, int64_t count, int centre) {
    gsf__moments m = {0.0, 0.0};
    if (centre) {
        for (int64_t i = 0; i < count; i++) m.mean += (double)x[i];
        m.mean /= (double)count;
    }
    for (int64_t i = 0; i < count; i++) m.square += ((double)x[i] - m.mean) * ((double)x[i] - m.mean);
    return m;
}

static void gsf__norm_row_scalar(const gsf__norm_job* job, const float* x, float* y) {
    const gsf__moments m = gsf__moments_scalar(x, job->dim, job->centre);
    const float inverse = gsf__norm_inverse(m, job->dim, job->eps);
    for (int64_t i = 0; i < job->dim; i++) {
        float v = (float)((double)x[i] - m.mean) * inverse;
        if (job->by.weight) v *= job->by.weight[i];
        if (job->by.bias) v += job->by.bias[i];
        if (job->by.scale) v = v * (1.0f + job->by.scale[i]) + job->by.shift[i];
        y[i] = v;
    }
}

static void gsf__norm_head_scalar(const gsf__norm_job* job, float* x, const float* cos, const float* sin) {
    gsf__norm_row_scalar(job, x, x);
    for (int64_t i = 0; cos && i + 1 < job->dim; i += 2) {
        const float a = x[i], b = x[i + 1];
        x[i] = a * cos[i] - b * sin[i];
        x[i + 1] = b * cos[i + 1] + a * sin[i + 1];
    }
}

static void gsf__norm_affine_scalar(const float* x, int64_t count, gsf__moments m, float inverse, float weight, float bias,
                                    float* y, int stream) {
    (void)stream;
    for (int64_t i = 0; i < count; i++) y[i] = (float)((double)x[i] - m.mean) * inverse * weight + bias;
}

// One-pass moments, in double. Values are taken relative to a pivot, one of them, so (mean - pivot)^2 is at most
// `count` times the variance, and the subtraction loses at most log2(count) of the 53 bits.
GSF__SHARED gsf__moments gsf__moments_of(double pivot, double sum, double square, int64_t count, int centre) {
    gsf__moments m = {0.0, square};
    if (!centre) return m;
    m.mean = pivot + sum / (double)count;
    m.square = square - sum * sum / (double)count;
    if (m.square < 0.0) m.square = 0.0;
    return m;
}

static void gsf__norm_silu_scalar(const float* x, int64_t count, const float* mean, const float* scale,
                                    const float* offset, float* y) {
    for (int64_t i = 0; i < count; i++)
        y[i] = gsf__nn_activation_ref(GSF__NN_SILU, (x[i] - mean[i]) * scale[i] + offset[i]);
}

#define gsf__moments_sums GSF__V(gsf__moments_sums)
#define gsf__moments_add GSF__V(gsf__moments_add)
#define gsf__norm_terms GSF__V(gsf__norm_terms)
#define gsf__norm_terms_of GSF__V(gsf__norm_terms_of)
#define gsf__norm_apply GSF__V(gsf__norm_apply)
#define gsf__norm_value GSF__V(gsf__norm_value)

#define GSF__KERNELS "gsfixer_nn.h"
#define GSF__KERNELS_NORMS
#define GSF__KERNELS_AVX512
#include "gsfixer.h"
#undef GSF__KERNELS_NORMS

#endif // GSF__ISA
#ifdef GSF__KERNELS_NORMS

typedef struct gsf__norm_terms { gsf__vf mean, low, inverse; } gsf__norm_terms; // mean + low: the mean as two floats

GSF__V_INLINE gsf__norm_terms gsf__norm_terms_of(gsf__moments m, float inverse) {
    const float mean = (float)m.mean;
    gsf__norm_terms n;
    n.mean = gsf__v_set(mean);
    n.low = gsf__v_set((float)(m.mean - (double)mean));
    n.inverse = gsf__v_set(inverse);
    return n;
}

// (x - mean) inverse, accurate to the resolution of the difference, as x - mean is exact if the two are close.
GSF__V_INLINE gsf__vf gsf__norm_apply(const gsf__norm_terms* n, gsf__vf x) { return ((x - n->mean) - n->low) * n->inverse; }

#if GSF__LANES > 1

typedef struct gsf__moments_sums { gsf__vd sum0, sum1, square0, square1; } gsf__moments_sums;

GSF__V_INLINE void gsf__moments_add(gsf__moments_sums* m, gsf__vd d0, gsf__vd d1) {
    m->sum0 = m->sum0 + d0;
    m->sum1 = m->sum1 + d1;
    m->square0 = gsf__vd_madd(d0, d0, m->square0);
    m->square1 = gsf__vd_madd(d1, d1, m->square1);
}

GSF__V_INLINE gsf__moments GSF__V(gsf__moments_all)(const float* x, int64_t count, int centre) {
    const int64_t half = GSF__LANES / GSF__HALVES;
    const float pivot = centre && count > 0 ? x[0] : 0.0f;
    const gsf__vd p = gsf__vd_set((double)pivot), zero = gsf__vd_set(0.0);
    gsf__moments_sums m = {zero, zero, zero, zero}, n = m;
    int64_t i = 0;
    for (; i + 4 * half <= count; i += 4 * half) {
        gsf__moments_add(&m, gsf__vd_load(x + i) - p, gsf__vd_load(x + i + half) - p);
        gsf__moments_add(&n, gsf__vd_load(x + i + 2 * half) - p, gsf__vd_load(x + i + 3 * half) - p);
    }
    if (i + 2 * half <= count) {
        gsf__moments_add(&m, gsf__vd_load(x + i) - p, gsf__vd_load(x + i + half) - p);
        i += 2 * half;
    }
    if (i < count) { // lanes past the last value hold the pivot and so contribute nothing
        const size_t left = (size_t)(count - i);
        const gsf__vf v = gsf__v_select(gsf__vm_first(left), gsf__v_load_first(x + i, left), gsf__v_set(pivot));
        gsf__moments_add(&m, gsf__vd_half(v, 0) - p, gsf__vd_half(v, 1) - p);
    }
    return gsf__moments_of((double)pivot, gsf__vd_sum((m.sum0 + m.sum1) + (n.sum0 + n.sum1)),
                           gsf__vd_sum((m.square0 + m.square1) + (n.square0 + n.square1)), count, centre);
}

GSF__V_KERNEL gsf__moments GSF__V(gsf__moments)(const float* x, int64_t count, int centre) {
    return GSF__V(gsf__moments_all)(x, count, centre);
}

// Normalises the `left` values from x[i] on; in loops over whole vectors `left` is a constant.
GSF__V_INLINE gsf__vf gsf__norm_value(gsf__norm_vectors by, const gsf__norm_terms* n, const float* x, int64_t i,
                                      size_t left) {
    gsf__vf v = gsf__norm_apply(n, gsf__v_load_first(x + i, left));
    if (by.weight) v = v * gsf__v_load_first(by.weight + i, left);
    if (by.bias) v = v + gsf__v_load_first(by.bias + i, left);
    if (by.scale)
        v = gsf__v_madd(v, gsf__v_set(1.0f) + gsf__v_load_first(by.scale + i, left), gsf__v_load_first(by.shift + i, left));
    return v;
}

GSF__V_INLINE void GSF__V(gsf__norm_row_all)(const gsf__norm_job* job, const float* x, float* y, int stream) {
    const gsf__moments m = GSF__V(gsf__moments_all)(x, job->dim, job->centre);
    const gsf__norm_terms n = gsf__norm_terms_of(m, gsf__norm_inverse(m, job->dim, job->eps));
    const gsf__norm_vectors by = job->by;
    const int64_t dim = job->dim;
    int64_t i = 0;
    for (; i + GSF__LANES <= dim; i += GSF__LANES) {
        gsf__nn_prefetch(x + dim + i); // the next row
        gsf__v_put(y + i, gsf__norm_value(by, &n, x, i, GSF__LANES), stream);
    }
    if (i < dim) gsf__v_store_first(y + i, gsf__norm_value(by, &n, x, i, (size_t)(dim - i)), (size_t)(dim - i));
}

GSF__V_KERNEL void GSF__V(gsf__norm_row)(const gsf__norm_job* job, const float* x, float* y) {
    if (job->stream) GSF__V(gsf__norm_row_all)(job, x, y, 1);
    else GSF__V(gsf__norm_row_all)(job, x, y, 0);
    gsf__nn_end_stream(job->stream);
}

GSF__V_KERNEL void GSF__V(gsf__norm_head)(const gsf__norm_job* job, float* x, const float* cos, const float* sin) {
    const gsf__moments m = GSF__V(gsf__moments_all)(x, job->dim, job->centre);
    const gsf__norm_terms n = gsf__norm_terms_of(m, gsf__norm_inverse(m, job->dim, job->eps));
    const gsf__norm_vectors by = job->by;
    const int64_t dim = job->dim;
    int64_t i = 0;
    for (; i + GSF__LANES <= dim; i += GSF__LANES) {
        gsf__vf v = gsf__norm_value(by, &n, x, i, GSF__LANES);
        if (cos) v = gsf__v_turn_pairs(v, gsf__v_load(cos + i), gsf__v_load(sin + i));
        gsf__v_store(x + i, v);
    }
    if (i == dim) return;
    const size_t left = (size_t)(dim - i);
    gsf__vf v = gsf__norm_value(by, &n, x, i, left);
    if (cos) { // an odd last value is not rotated
        const gsf__vf turned = gsf__v_turn_pairs(v, gsf__v_load_first(cos + i, left), gsf__v_load_first(sin + i, left));
        v = gsf__v_select(gsf__vm_first(left / 2 * 2), turned, v);
    }
    gsf__v_store_first(x + i, v, left);
}

GSF__V_INLINE void GSF__V(gsf__norm_affine_all)(const float* x, int64_t count, gsf__moments m, float inverse, float weight,
                                                float bias, float* y, int stream) {
    const gsf__norm_terms n = gsf__norm_terms_of(m, inverse);
    const gsf__vf w = gsf__v_set(weight), b = gsf__v_set(bias);
    int64_t i = 0;
    for (; i + GSF__LANES <= count; i += GSF__LANES)
        gsf__v_put(y + i, gsf__v_madd(gsf__norm_apply(&n, gsf__v_load(x + i)), w, b), stream);
    const size_t left = (size_t)(count - i);
    if (left) gsf__v_store_first(y + i, gsf__v_madd(gsf__norm_apply(&n, gsf__v_load_first(x + i, left)), w, b), left);
}

GSF__V_KERNEL void GSF__V(gsf__norm_affine)(const float* x, int64_t count, gsf__moments m, float inverse, float weight,
                                            float bias, float* y, int stream) {
    if (stream) GSF__V(gsf__norm_affine_all)(x, count, m, inverse, weight, bias, y, 1);
    else GSF__V(gsf__norm_affine_all)(x, count, m, inverse, weight, bias, y, 0);
    gsf__nn_end_stream(stream);
}

GSF__V_INLINE void GSF__V(gsf__norm_silu_first)(const float* x, const float* mean, const float* scale, const float* offset,
                                                float* y, size_t left) {
    const gsf__vf d = gsf__v_load_first(x, left) - gsf__v_load_first(mean, left);
    const gsf__vf v = gsf__v_madd(d, gsf__v_load_first(scale, left), gsf__v_load_first(offset, left));
    gsf__v_store_first(y, gsf__v_activate(GSF__NN_SILU, v), left);
}

GSF__V_KERNEL void GSF__V(gsf__norm_silu)(const float* x, int64_t count, const float* mean, const float* scale,
                                          const float* offset, float* y) {
    int64_t i = 0;
    for (; i + GSF__LANES <= count; i += GSF__LANES)
        GSF__V(gsf__norm_silu_first)(x + i, mean + i, scale + i, offset + i, y + i, GSF__LANES);
    const size_t left = (size_t)(count - i);
    if (left) GSF__V(gsf__norm_silu_first)(x + i, mean + i, scale + i, offset + i, y + i, left);
}

#endif
#endif // GSF__KERNELS_NORMS
#ifndef GSF__ISA

static const gsf__norm_kernels* gsf__norm_kernels_of(gsf_cpu_level level) {
    static const gsf__norm_kernels scalar = {gsf__moments_scalar, gsf__norm_row_scalar, gsf__norm_head_scalar,
                                             gsf__norm_affine_scalar};
#if GSF__X86
    static const gsf__norm_kernels avx2 = {gsf__moments_avx2, gsf__norm_row_avx2, gsf__norm_head_avx2,
                                           gsf__norm_affine_avx2};
    static const gsf__norm_kernels avx512 = {gsf__moments_avx512, gsf__norm_row_avx512, gsf__norm_head_avx512,
                                             gsf__norm_affine_avx512};
    if (level >= GSF_CPU_AVX512) return &avx512;
    if (level >= GSF_CPU_AVX2) return &avx2;
#endif
    (void)level;
    return &scalar;
}

static void gsf__norm_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * job->chunk_rows;
    for (int64_t r = begin; r < begin + job->chunk_rows && r < job->rows; r++)
        job->kernels->row(job, job->x + r * job->dim, job->y + r * job->dim);
}

static void gsf__norm_rows(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, gsf__norm_vectors by, float eps,
                           int centre, float* y) {
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__norm_kernels_of(ctx->cpu_level);
    job.x = x;
    job.y = y;
    job.rows = rows;
    job.dim = dim;
    job.by = by;
    job.eps = eps;
    job.centre = centre;
    job.chunk_rows = gsf__nn_chunk_rows(dim);
    job.stream = gsf__nn_streams(x, y, rows * dim, dim);
    gsf__parallel_for(ctx, gsf__nn_chunks(rows, job.chunk_rows), gsf__norm_chunk, &job);
}

// Normalisations over the last dimension of (rows, dim); y may be x; weight and bias are (dim) or NULL. Variances are
// biased; sums are in double.

// y = layer_norm(x) * (1 + scale) + shift, scale and shift (dim): an adaptive layer norm in one pass.
static void gsf__nn_layer_norm_modulated(gsf_context* ctx, const float* x, int64_t rows, int64_t dim,
                                         const float* weight, const float* bias, float eps, const float* scale,
                                         const float* shift, float* y) {
    const gsf__norm_vectors by = {weight, bias, scale, shift};
    gsf__norm_rows(ctx, x, rows, dim, by, eps, 1, y);
}

static void gsf__nn_layer_norm(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight,
                               const float* bias, float eps, float* y) {
    gsf__nn_layer_norm_modulated(ctx, x, rows, dim, weight, bias, eps, NULL, NULL, y);
}

static void gsf__nn_rms_norm(gsf_context* ctx, const float* x, int64_t rows, int64_t dim, const float* weight,
                             float eps, float* y) {
    const gsf__norm_vectors by = {weight, NULL, NULL, NULL};
    gsf__norm_rows(ctx, x, rows, dim, by, eps, 0, y);
}

// Groups are split into parts that fit a core's cache, so that each part is read once for both moments and even a few
// large groups keep all workers busy. The moments of the parts are combined in order (Chan et al. 1979). Groups are
// processed in batches that fit the shared cache, so that normalising finds them still cached.
enum { GSF__NORM_PART = 1 << 16, GSF__NORM_PARTS = 1024 }; // values per part; maximum number of parts per group
enum { GSF__NORM_BATCH = 1 << 21 };                        // values per batch of groups

static void gsf__norm_group_values(const gsf__norm_job* job, int64_t group, int64_t part, gsf__moments m, float inverse) {
    const int64_t begin = part * job->part_size, first = group * job->group_size; // begin, end: in the group
    const int64_t end = gsf__least(begin + job->part_size, job->group_size);
    for (int64_t i = begin; i < end;) { // channel by channel
        const int64_t channel = (first + i) / job->dim, next = (channel + 1) * job->dim - first;
        const int64_t count = gsf__least(next, end) - i;
        job->kernels->affine(job->x + first + i, count, m, inverse, job->by.weight ? job->by.weight[channel] : 1.0f,
                             job->by.bias ? job->by.bias[channel] : 0.0f, job->y + first + i, job->stream);
        i += count;
    }
}

static gsf__moments gsf__norm_part(const gsf__norm_job* job, int64_t group, int64_t part, int64_t* count) {
    *count = gsf__least(job->part_size, job->group_size - part * job->part_size);
    return job->kernels->moments(job->x + group * job->group_size + part * job->part_size, *count, 1);
}

static void gsf__norm_whole_group(void* arg, size_t group, int32_t worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    int64_t count;
    const gsf__moments m = gsf__norm_part(job, (int64_t)group, 0, &count);
    gsf__norm_group_values(job, (int64_t)group, 0, m, gsf__norm_inverse(m, count, job->eps));
}

static void gsf__norm_part_moments(void* arg, size_t chunk, int32_t worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    int64_t count;
    const int64_t group = job->first_group + (int64_t)chunk / job->parts;
    job->part_moments[chunk] = gsf__norm_part(job, group, (int64_t)chunk % job->parts, &count);
}

static void gsf__norm_part_values(void* arg, size_t chunk, int32_t worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    const int64_t group = (int64_t)chunk / job->parts;
    const gsf__moments* of = job->part_moments + group * job->parts;
    gsf__moments m = of[0];
    for (int64_t p = 1; p < job->parts; p++) {
        const double before = (double)(p * job->part_size), delta = of[p].mean - m.mean;
        const double after = (double)gsf__least((p + 1) * job->part_size, job->group_size);
        const double share = (after - before) / after;
        m.mean += delta * share;
        m.square += of[p].square + delta * delta * before * share;
    }
    gsf__norm_group_values(job, job->first_group + group, (int64_t)chunk % job->parts, m,
                           gsf__norm_inverse(m, job->group_size, job->eps));
}

// x: (channels, count); statistics are over all values of the channels of a group; y may be x.
GSF__SHARED void gsf__nn_group_norm(gsf_context* ctx, const float* x, int64_t channels, int64_t count, int64_t groups,
                                    const float* weight, const float* bias, float eps, float* y) {
    gsf__moments part_moments[GSF__NORM_PARTS];
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    if (channels < 1 || count < 1 || groups < 1) return;
    job.kernels = gsf__norm_kernels_of(ctx->cpu_level);
    job.x = x;
    job.y = y;
    job.rows = channels;
    job.dim = count;
    job.by.weight = weight;
    job.by.bias = bias;
    job.eps = eps;
    job.stream = gsf__nn_streams(x, y, channels * count, count);
    job.group_size = channels / groups * count;
    job.part_size = gsf__ceil_div(job.group_size, gsf__least((int64_t)gsf__nn_chunks(job.group_size, GSF__NORM_PART),
                                                             GSF__NORM_PARTS));
    job.part_size = gsf__round_up(job.part_size, 16);
    job.parts = gsf__ceil_div(job.group_size, job.part_size);
    if (job.parts == 1) {
        gsf__parallel_for(ctx, (size_t)groups, gsf__norm_whole_group, &job);
        return;
    }
    job.part_moments = part_moments;
    int64_t batch = gsf__least(GSF__NORM_BATCH / job.group_size, GSF__NORM_PARTS / job.parts);
    if (batch < 1) batch = 1;
    for (; job.first_group < groups; job.first_group += batch) {
        const size_t parts = (size_t)(gsf__least(batch, groups - job.first_group) * job.parts);
        gsf__parallel_for(ctx, parts, gsf__norm_part_moments, &job);
        gsf__parallel_for(ctx, parts, gsf__norm_part_values, &job);
    }
}

static void gsf__head_norm_rope_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__norm_job* job = (const gsf__norm_job*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * job->chunk_rows;
    for (int64_t r = begin; r < begin + job->chunk_rows && r < job->rows; r++) {
        const int64_t at = (r - job->rope_first) * job->dim;
        const int turn = job->cos && at >= 0;
        const float *cos = turn ? job->cos + at : NULL, *sin = turn ? job->sin + at : NULL;
        for (int32_t h = 0; h < job->heads; h++) job->kernels->head(job, job->y + r * job->stride + h * job->dim, cos, sin);
    }
}

// In place: LayerNorm over each head of q or k, then the rotary embedding of interleaved pairs from row `rope_first`
// on. cos, sin: (rows - rope_first, head_dim) or NULL: no rotation. weight, bias: (head_dim) or NULL.
static void gsf__nn_head_norm_rope(gsf_context* ctx, float* x, int64_t rows, int64_t ldx, int32_t heads,
                                   int32_t head_dim, const float* weight, const float* bias, float eps,
                                   const float* cos, const float* sin, int64_t rope_first) {
    gsf__norm_job job;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__norm_kernels_of(ctx->cpu_level);
    job.y = x;
    job.rows = rows;
    job.stride = ldx ? ldx : (int64_t)heads * head_dim;
    job.dim = head_dim;
    job.heads = heads;
    job.by.weight = weight;
    job.by.bias = bias;
    job.eps = eps;
    job.centre = 1;
    job.cos = cos;
    job.sin = sin;
    job.rope_first = rope_first;
    job.chunk_rows = gsf__nn_chunk_rows((int64_t)heads * head_dim);
    gsf__parallel_for(ctx, gsf__nn_chunks(rows, job.chunk_rows), gsf__head_norm_rope_chunk, &job);
}

// ---- >>nn linear ----------------------------------------------------------------
//
// Products x w^T by blocks (Goto and van de Geijn 2008; BLIS, Van Zee and van de Geijn 2015). The operands of the
// innermost kernel are packed so that it reads them sequentially; the weights are transposed and widened to float while
// packing:
//
//     x [group of 6 rows][k][6]        w [panel of 16 outputs][k][16]        sums [panel][group][6][16]
//
// A block of a few hundred rows and outputs is one unit of parallel work. It traverses the inner dimension in steps of
// `depth`, so that this much of its rows fits the L2 cache and of one panel the L1 cache; each tile of 6 x 16 sums is
// held in registers. AVX-512 computes two groups by two panels at a time, 12 x 32 sums, on request with pairs of bf16
// in the place of floats. After the last step a tile goes through bias, activation, gate and residual into y while it
// is still in cache. The weights are packed once per call for all blocks, or, if one block covers all rows, by the
// worker that needs them. With up to 4 rows (GEMV) reading the weights once is the bottleneck, so they are not packed
// but used as stored in the file. Each `depth` is summed by itself and these sums are added in order, so the result
// does not depend on the number of workers.

enum {
    GSF__TILE_ROWS = 6,
    GSF__TILE_COLUMNS = 16,
    GSF__TILE_SUMS = GSF__TILE_ROWS * GSF__TILE_COLUMNS,
    GSF__LINEAR_PAIR = 2 * GSF__TILE_COLUMNS, // panels are processed in pairs
    GSF__LINEAR_DEPTH = 256,          // this much of a panel is 16 KiB, half of an L1 cache
    GSF__LINEAR_ROWS = 192,           // of a block, at least two groups; times depth: 192 KiB
    GSF__LINEAR_COLUMNS = 768,
    GSF__LINEAR_LONE_ROWS = 320,      // up to this many rows form a single block
    GSF__LINEAR_LONE_COLUMNS = 192,
    GSF__GEMV_ROWS = 4,               // up to this many rows, weights are not packed
    GSF__GEMV_CHUNKS = 32,            // maximum number of work units; few, as the hardware prefetcher restarts in each
    GSF__GEMV_BYTES = 1 << 16,        // minimum bytes of weights per unit
    GSF__GEMV_COLUMNS = 1008,         // maximum outputs per unit; a multiple of 6 and 16, like GSF__GEMV_UNIT
    GSF__GEMV_UNIT = 48,
    GSF__GEMV_PAD = 32,               // values of x are padded to a multiple of this
    GSF__GEMV_AHEAD = 1280,           // AVX-512: prefetch distance in bytes within each row of weights
    GSF__GEMV_AHEAD16 = 2048,         // the same for 16-bit weights
    GSF__GEMV_STEP = 1024             // values of four rows of x that are processed at a time
};

#ifndef GSF__LINEAR_PACKED // a test lowers it
#define GSF__LINEAR_PACKED ((int64_t)1 << 24) // maximum number of packed weights (floats) in memory at a time: 64 MiB
#endif

typedef struct gsf__linear_job gsf__linear_job;

typedef struct gsf__linear_kernels { // one set per instruction set
    // out[k][16]: `columns` rows of weights, `pitch` bytes apart, transposed; missing columns are zero
    void (*pack_weights)(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t columns, int64_t count, float* out);
    // out[k][6]: `rows` rows of x, transposed; missing rows are zero; may write two floats more
    void (*pack_rows)(const float* x, int64_t ldx, int64_t rows, int64_t count, float* out);
    // sums[6][16] = a[k][6]^T b[k][16], or += with `add`; also prefetches `ahead_count` floats that are needed next
    void (*tile)(const float* a, const float* b, int64_t count, int add, float* sums, const float* ahead,
                 int64_t ahead_count);
    // The same for two consecutive groups and two panels, whose sums are `next` floats apart; may be NULL
    void (*four_tiles)(const float* a, const float* b, int64_t count, int add, float* sums, int64_t next,
                       const float* ahead, int64_t ahead_count);
    // Writes sums (row stride `pitch`, readable up to the next multiple of 8 columns) to y from `row`, `column` on
    void (*epilogue)(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row, int64_t rows, int64_t column,
                   int64_t columns);
    // sums[m*pitch + c] = row m of x times row column + c of the weights
    void (*gemv)(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums, int64_t pitch);
    int64_t gemv_lanes; // layout of job->gemv_x, which `gemv` reads: [k / lanes][rows][lanes]; 0: it reads desc.x
    int64_t unit;      // values per packed float: 1, or 2 in bf16; counts of packed values are in units
} gsf__linear_kernels;

typedef struct gsf__linear_plan { // how a product is divided; depends on its sizes only
    int64_t depth;                // of a step through the inner dimension
    int64_t block_rows, block_columns, row_blocks;
    int64_t group_columns;        // outputs packed at a time
    int gemv, lone;                // up to 4 rows; one block covers all rows
    size_t shared, per_worker;    // floats of scratch
} gsf__linear_plan;

struct gsf__linear_job {
    gsf__nn_linear_desc desc;
    gsf__linear_plan plan;
    const gsf__linear_kernels* kernels;
    int64_t in, out;
    int64_t length;               // `in` in units
    int64_t first, columns;       // the current group of outputs
    float *bias, *packed, *gemv_x; // bias: zeros if there is none, 16 more than `out`
    float* workers;
};

// Size of the pieces if `total` is split evenly into pieces of at most `most`; rounded up to a multiple of `unit`.
static int64_t gsf__even_piece(int64_t total, int64_t most, int64_t unit) {
    return gsf__round_up(gsf__ceil_div(total, gsf__ceil_div(total, most)), unit);
}

// The number of rows of the GEMV kernel that handles `rows` rows.
static int64_t gsf__gemv_rows(int64_t rows) { return rows < 3 ? rows : (int64_t)GSF__GEMV_ROWS; }

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

// Packs the part of a panel from step k and column `first` on.
static void gsf__pack_corner(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t first, int64_t columns, int64_t k,
                             int64_t count, float* out) {
    const size_t size = gsf_nn_get_dtype_size(dtype);
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

static void gsf__tile_scalar(const float* a, const float* b, int64_t count, int add, float* sums, const float* ahead,
                             int64_t ahead_count) {
    float c[GSF__TILE_SUMS];
    (void)ahead;
    (void)ahead_count;
    memset(c, 0, sizeof c);
    for (int64_t k = 0; k < count; k++, a += GSF__TILE_ROWS, b += GSF__TILE_COLUMNS)
        for (int i = 0; i < GSF__TILE_ROWS; i++)
            for (int j = 0; j < GSF__TILE_COLUMNS; j++) c[i * GSF__TILE_COLUMNS + j] += a[i] * b[j];
    for (int i = 0; i < GSF__TILE_SUMS; i++) sums[i] = add ? sums[i] + c[i] : c[i];
}

static void gsf__epilogue_scalar(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row, int64_t rows,
                                 int64_t column, int64_t columns) {
    const gsf__nn_linear_desc* d = &job->desc;
    for (int64_t r = 0; r < rows; r++) {
        float* y = d->y + (row + r) * d->ldy + column;
        for (int64_t c = 0; c < columns; c++) {
            const float value = gsf__nn_activation_ref(d->activation, sums[r * pitch + c] + job->bias[column + c]);
            y[c] = d->gate ? y[c] + d->gate[column + c] * value : d->accumulate ? y[c] + value : value;
        }
    }
}

static void gsf__gemv_scalar(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums, int64_t pitch) {
    const gsf__nn_linear_desc* d = &job->desc;
    const size_t size = gsf_nn_get_dtype_size(d->weight->dtype);
    for (int64_t c = 0; c < columns; c++)
        for (int64_t m = 0; m < d->rows; m++) {
            const char* w = (const char*)d->weight->data + (size_t)(column + c) * (size_t)job->in * size;
            float sum = 0.0f;
            for (int64_t k = 0; k < job->in; k++, w += size)
                sum += d->x[m * d->ldx + k] * gsf__nn_load(w, d->weight->dtype);
            sums[m * pitch + c] = sum;
        }
}

static const gsf__linear_kernels gsf__linear_scalar = {gsf__pack_weights_scalar, gsf__pack_rows_scalar, gsf__tile_scalar,
                                                       NULL, gsf__epilogue_scalar, gsf__gemv_scalar, 0, 1};

// The epilogue: bias, activation, gate and residual.
#define GSF__KERNELS "gsfixer_nn.h"
#define GSF__KERNELS_EPILOGUE
#define GSF__KERNELS_AVX512
#include "gsfixer.h"
#undef GSF__KERNELS_EPILOGUE

#endif // GSF__ISA
#ifdef GSF__KERNELS_EPILOGUE
#if GSF__LANES > 1

// Writes `left` outputs from column `column` on; `sums` starts at that column.
GSF__V_INLINE void GSF__V(gsf__epilogue_columns)(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row,
                                                 int64_t rows, int64_t column, size_t left) {
    const gsf__nn_linear_desc* d = &job->desc;
    const gsf__vf bias = gsf__v_load_first(job->bias + column, left);
    const gsf__vf gate = d->gate ? gsf__v_load_first(d->gate + column, left) : gsf__v_set(1.0f);
    for (int64_t r = 0; r < rows; r++) {
        float* y = d->y + (row + r) * d->ldy + column;
        gsf__vf v = gsf__v_activate(d->activation, gsf__v_load_first(sums + r * pitch, left) + bias);
        if (d->gate || d->accumulate) v = gsf__v_madd(gate, v, gsf__v_load_first(y, left));
        gsf__v_store_first(y, v, left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__epilogue)(const gsf__linear_job* job, const float* sums, int64_t pitch, int64_t row,
                                         int64_t rows, int64_t column, int64_t columns) {
    int64_t c = 0;
    for (; c + GSF__LANES <= columns; c += GSF__LANES)
        GSF__V(gsf__epilogue_columns)(job, sums + c, pitch, row, rows, column + c, GSF__LANES);
    const size_t left = (size_t)(columns - c);
    if (left) GSF__V(gsf__epilogue_columns)(job, sums + c, pitch, row, rows, column + c, left);
}

#endif
#endif // GSF__KERNELS_EPILOGUE
#ifndef GSF__ISA

// ---- linear: AVX2 kernels

#if GSF__X86

GSF__INLINE_AVX2 __m256 gsf__load8(const char* p, gsf_nn_dtype dtype) { // eight weights, widened
    if (dtype == GSF_NN_F32) return _mm256_loadu_ps((const float*)(const void*)p);
    const __m128i bits = _mm_loadu_si128((const __m128i*)(const void*)p);
    if (dtype == GSF_NN_F16) return _mm256_cvtph_ps(bits);
    return _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_cvtepu16_epi32(bits), 16));
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
            __m256 r[8] = {gsf__load8(p, dtype),             gsf__load8(p + pitch, dtype),
                           gsf__load8(p + 2 * pitch, dtype), gsf__load8(p + 3 * pitch, dtype),
                           gsf__load8(p + 4 * pitch, dtype), gsf__load8(p + 5 * pitch, dtype),
                           gsf__load8(p + 6 * pitch, dtype), gsf__load8(p + 7 * pitch, dtype)};
            gsf__nn_store_columns(r, to, GSF__TILE_COLUMNS);
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
    int64_t step[GSF__TILE_ROWS]; // all bits set, or 0 for a missing row
    const int64_t whole = count & ~(int64_t)7;
    float* to = out;
    for (int64_t r = 0; r < GSF__TILE_ROWS; r++) {
        p[r] = r < rows ? x + r * ldx : zeros;
        step[r] = r < rows ? -1 : 0;
    }
    for (int64_t k = 0; k < whole; k += 8, to += 8 * GSF__TILE_ROWS) {
        __m256 r[8] = {_mm256_loadu_ps(p[0] + (k & step[0])), _mm256_loadu_ps(p[1] + (k & step[1])),
                       _mm256_loadu_ps(p[2] + (k & step[2])), _mm256_loadu_ps(p[3] + (k & step[3])),
                       _mm256_loadu_ps(p[4] + (k & step[4])), _mm256_loadu_ps(p[5] + (k & step[5])),
                       _mm256_setzero_ps(), _mm256_setzero_ps()};
        gsf__nn_store_columns(r, to, GSF__TILE_ROWS); // each step's last two floats are overwritten by the next step
    }
    for (int64_t k = whole; k < count; k++)
        for (int i = 0; i < GSF__TILE_ROWS; i++) out[k * GSF__TILE_ROWS + i] = i < rows ? p[i][k] : 0.0f;
}

// The micro-kernel of GEMM and attention: c[2 r], c[2 r + 1] = the 16 sums over k of a[r a_row + k a_step] b[16 k ...]
// for 6 rows r. 12 registers of sums, 2 of b, 1 or 2 of a.
GSF__INLINE_AVX2 void gsf__nn_tile(const float* a, int64_t a_row, int64_t a_step, const float* b, int64_t count,
                                   __m256 c[12]) {
    __m256 c00 = _mm256_setzero_ps(), c01 = c00, c10 = c00, c11 = c00, c20 = c00, c21 = c00;
    __m256 c30 = c00, c31 = c00, c40 = c00, c41 = c00, c50 = c00, c51 = c00;
    __m256 x, b0, b1;
#define GSF_X(r, k)                                          \
    x = _mm256_broadcast_ss(a + (r) * a_row + (k) * a_step); \
    c##r##0 = _mm256_fmadd_ps(x, b0, c##r##0);               \
    c##r##1 = _mm256_fmadd_ps(x, b1, c##r##1);
#define GSF_STEP(k)                                        \
    b0 = _mm256_loadu_ps(b + (k) * GSF__TILE_COLUMNS);     \
    b1 = _mm256_loadu_ps(b + (k) * GSF__TILE_COLUMNS + 8); \
    GSF_X(0, k) GSF_X(1, k) GSF_X(2, k) GSF_X(3, k) GSF_X(4, k) GSF_X(5, k)
    int64_t k = 0;
    for (; k + 4 <= count; k += 4, a += 4 * a_step, b += 4 * GSF__TILE_COLUMNS) {
        GSF_STEP(0) GSF_STEP(1) GSF_STEP(2) GSF_STEP(3)
    }
    for (; k < count; k++, a += a_step, b += GSF__TILE_COLUMNS) { GSF_STEP(0) }
#undef GSF_STEP
#undef GSF_X
    c[0] = c00; c[1] = c01; c[2] = c10; c[3] = c11; c[4] = c20; c[5] = c21;
    c[6] = c30; c[7] = c31; c[8] = c40; c[9] = c41; c[10] = c50; c[11] = c51;
}

GSF__TARGET_AVX2 static void gsf__tile_avx2(const float* a, const float* b, int64_t count, int add, float* sums,
                                            const float* ahead, int64_t ahead_count) {
    __m256 c[12];
    for (int i = 0; i < GSF__TILE_SUMS; i += 16) _mm_prefetch((const char*)(sums + i), _MM_HINT_T0);
    for (int64_t i = 0; i < ahead_count; i += 16) _mm_prefetch((const char*)(ahead + i), _MM_HINT_T1);
    gsf__nn_tile(a, 1, GSF__TILE_ROWS, b, count, c);
#define GSF_X(i) _mm256_store_ps(sums + 8 * (i), add ? _mm256_add_ps(_mm256_load_ps(sums + 8 * (i)), c[i]) : c[i]);
    GSF_X(0) GSF_X(1) GSF_X(2) GSF_X(3) GSF_X(4) GSF_X(5) GSF_X(6) GSF_X(7) GSF_X(8) GSF_X(9) GSF_X(10) GSF_X(11)
#undef GSF_X
}

// GEMV with up to 4 rows of x. A core that multiplies while reading has too few loads in flight to saturate memory, and
// loads of x make that worse. So several rows of weights share each load of x, and weights are prefetched. The
// processor drops prefetches when too many are pending; hence each is issued twice, `ahead` bytes (the rows of a tile)
// and twice that ahead.
GSF__INLINE_AVX2 void gsf__gemv_fetch(const char* p, size_t ahead) {
    _mm_prefetch(p + ahead, _MM_HINT_T1);
    _mm_prefetch(p + 2 * ahead, _MM_HINT_T1);
}

GSF__INLINE_AVX2 __m128 gsf__sum8x4(__m256 a, __m256 b, __m256 c, __m256 d) { // the horizontal sums of four vectors
    const __m256 v = _mm256_hadd_ps(_mm256_hadd_ps(a, b), _mm256_hadd_ps(c, d));
    return _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
}

GSF__INLINE_AVX2 void gsf__gemv_add(float* sums, __m256 a, __m256 b, __m256 c, __m256 d) {
    _mm_storeu_ps(sums, _mm_add_ps(_mm_loadu_ps(sums), gsf__sum8x4(a, b, c, d)));
}

// Six rows of weights times one or two rows of x, laid out as [k / 8][rows][8], added to sums[6][rows] (with one row of
// x, also writes two floats past the end). `count` is a multiple of 32; a cache line holds `line` weights.
GSF__INLINE_AVX2 void gsf__gemv_six(const char* const w[6], gsf_nn_dtype dtype, size_t ahead, const float* x, int64_t rows,
                                    int64_t count, float* sums) {
    const char *w0 = w[0], *w1 = w[1], *w2 = w[2], *w3 = w[3], *w4 = w[4], *w5 = w[5];
    const int64_t line = dtype == GSF_NN_F32 ? 16 : 32, vector = dtype == GSF_NN_F32 ? 32 : 16; // weights; bytes
    __m256 s00 = _mm256_setzero_ps(), s10 = s00, s20 = s00, s30 = s00, s40 = s00, s50 = s00;
    __m256 s01 = s00, s11 = s00, s21 = s00, s31 = s00, s41 = s00, s51 = s00;
    for (int64_t at = 0; count > 0; count -= line) {
#define GSF_X(r) gsf__gemv_fetch(w##r + at, ahead);
        GSF__SIX(GSF_X)
#undef GSF_X
        for (int64_t i = 0; i < line; i += 8, at += vector, x += 8 * rows) {
            const __m256 x0 = _mm256_load_ps(x), x1 = rows > 1 ? _mm256_load_ps(x + 8) : x0;
            __m256 v;
#define GSF_X(r)                                           \
            v = gsf__load8(w##r + at, dtype);              \
            s##r##0 = _mm256_fmadd_ps(v, x0, s##r##0);     \
            if (rows > 1) s##r##1 = _mm256_fmadd_ps(v, x1, s##r##1);
            GSF__SIX(GSF_X)
#undef GSF_X
        }
    }
    if (rows == 1) {
        gsf__gemv_add(sums, s00, s10, s20, s30);
        gsf__gemv_add(sums + 4, s40, s50, s01, s11);
        return;
    }
    gsf__gemv_add(sums, s00, s01, s10, s11);
    gsf__gemv_add(sums + 4, s20, s21, s30, s31);
    gsf__gemv_add(sums + 8, s40, s41, s50, s51);
}

// Three rows of weights times four rows of x, as above.
GSF__INLINE_AVX2 void gsf__gemv_three(const char* const w[3], gsf_nn_dtype dtype, size_t ahead, const float* x,
                                      int64_t count, float* sums) {
    const char *w0 = w[0], *w1 = w[1], *w2 = w[2];
    const int64_t line = dtype == GSF_NN_F32 ? 16 : 32, vector = dtype == GSF_NN_F32 ? 32 : 16;
    __m256 s00 = _mm256_setzero_ps(), s01 = s00, s02 = s00, s03 = s00, s10 = s00, s11 = s00;
    __m256 s12 = s00, s13 = s00, s20 = s00, s21 = s00, s22 = s00, s23 = s00;
    for (int64_t at = 0; count > 0; count -= line) {
        gsf__gemv_fetch(w0 + at, ahead);
        gsf__gemv_fetch(w1 + at, ahead);
        gsf__gemv_fetch(w2 + at, ahead);
        for (int64_t i = 0; i < line; i += 8, at += vector, x += 32) {
            const __m256 a = gsf__load8(w0 + at, dtype), b = gsf__load8(w1 + at, dtype), c = gsf__load8(w2 + at, dtype);
            __m256 v;
#define GSF_X(m)                                        \
            v = _mm256_load_ps(x + 8 * (m));            \
            s0##m = _mm256_fmadd_ps(a, v, s0##m);       \
            s1##m = _mm256_fmadd_ps(b, v, s1##m);       \
            s2##m = _mm256_fmadd_ps(c, v, s2##m);
            GSF_X(0) GSF_X(1) GSF_X(2) GSF_X(3)
#undef GSF_X
        }
    }
    gsf__gemv_add(sums, s00, s01, s02, s03);
    gsf__gemv_add(sums + 4, s10, s11, s12, s13);
    gsf__gemv_add(sums + 8, s20, s21, s22, s23);
}

GSF__INLINE_AVX2 void gsf__gemv_tile(const char* const w[6], gsf_nn_dtype dtype, size_t ahead, const float* x, int64_t rows,
                                     int64_t count, float* sums) {
    if (rows == 1) gsf__gemv_six(w, dtype, ahead, x, 1, count, sums);
    else if (rows == 2) gsf__gemv_six(w, dtype, ahead, x, 2, count, sums);
    else gsf__gemv_three(w, dtype, ahead, x, count, sums);
}

GSF__INLINE_AVX2 void gsf__gemv8(const gsf__linear_job* job, gsf_nn_dtype dtype, size_t size, int64_t column,
                                 int64_t columns, float* sums, int64_t pitch) {
    const size_t bytes = (size_t)job->in * size;
    const char* first = (const char*)job->desc.weight->data + (size_t)column * bytes;
    const int64_t rows = gsf__gemv_rows(job->desc.rows), height = rows > 2 ? 3 : 6; // rows of x and of weights
    const int64_t whole = job->in / GSF__GEMV_PAD * GSF__GEMV_PAD;
    const size_t left = (size_t)(job->in - whole) * size;
    const char* w[6];
    char tails[6][4 * GSF__GEMV_PAD];
    memset(tails, 0, sizeof tails);
    for (int64_t c = 0; c < columns; c += height) {
        float tile[12] = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0}; // [weights][x]
        for (int64_t r = 0; r < height; r++) w[r] = first + (size_t)gsf__least(c + r, columns - 1) * bytes;
        gsf__gemv_tile(w, dtype, (size_t)height * bytes, job->gemv_x, rows, whole, tile);
        for (int64_t r = 0; left > 0 && r < height; r++) {
            memcpy(tails[r], w[r] + (size_t)whole * size, left);
            w[r] = tails[r];
        }
        if (left > 0) gsf__gemv_tile(w, dtype, 0, job->gemv_x + whole * rows, rows, GSF__GEMV_PAD, tile);
        for (int64_t r = 0; r < gsf__least(height, columns - c); r++)
            for (int64_t m = 0; m < job->desc.rows; m++) sums[m * pitch + c + r] = tile[r * rows + m];
    }
}

GSF__TARGET_AVX2 static void gsf__gemv_avx2(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums,
                                            int64_t pitch) {
    const gsf_nn_dtype dtype = job->desc.weight->dtype;
    if (dtype == GSF_NN_F32) gsf__gemv8(job, GSF_NN_F32, 4, column, columns, sums, pitch);
    else if (dtype == GSF_NN_BF16) gsf__gemv8(job, GSF_NN_BF16, 2, column, columns, sums, pitch);
    else gsf__gemv8(job, GSF_NN_F16, 2, column, columns, sums, pitch);
}

static const gsf__linear_kernels gsf__linear_avx2 = {gsf__pack_weights_avx2, gsf__pack_rows_avx2, gsf__tile_avx2,
                                                     NULL, gsf__epilogue_avx2, gsf__gemv_avx2, 8, 1};

// ---- linear: AVX-512 kernels

// 24 registers of sums, 2 of b, 1 or 2 of a; multiply(sum, a, b) adds the products to `sum`.
#define GSF__FOUR_ZEROS(i) __m512 c##i = _mm512_setzero_ps(), d##i = c##i, e##i = c##i, f##i = c##i;
#define GSF__FOUR_PUT(to, v) _mm512_store_ps(to, add ? _mm512_add_ps(_mm512_load_ps(to), v) : v);
#define GSF__FOUR_STORE(i)                                                                                              \
    GSF__FOUR_PUT(sums + 16 * (i), c##i) GSF__FOUR_PUT(right + 16 * (i), d##i)                                          \
    GSF__FOUR_PUT(sums + GSF__TILE_SUMS + 16 * (i), e##i) GSF__FOUR_PUT(right + GSF__TILE_SUMS + 16 * (i), f##i)
// As gsf__nn_tile, for two groups of rows, `a_next` apart, and two panels, `b_next` apart. Sums are added to c, d
// (first group, by panel) and e, f, in the same order as there. `each` is executed in every step.
#define GSF__FOUR_TILES(multiply, each, a, a_row, a_step, a_next, b, b_next, count)                                     \
    for (int64_t k_ = 0; k_ < (count); k_++, a += a_step, b += GSF__TILE_COLUMNS) {                                     \
        const __m512 w0 = _mm512_loadu_ps(b), w1 = _mm512_loadu_ps(b + (b_next));                                       \
        __m512 x;                                                                                                       \
        each                                                                                                            \
        GSF__FOUR_STEP(0, multiply, a_row, a_next) GSF__FOUR_STEP(1, multiply, a_row, a_next)                           \
        GSF__FOUR_STEP(2, multiply, a_row, a_next) GSF__FOUR_STEP(3, multiply, a_row, a_next)                           \
        GSF__FOUR_STEP(4, multiply, a_row, a_next) GSF__FOUR_STEP(5, multiply, a_row, a_next)                           \
    }
#define GSF__FOUR_STEP(r, multiply, a_row, a_next)        \
    x = _mm512_set1_ps(a[(r) * (a_row)]);                 \
    c##r = multiply(c##r, x, w0);                         \
    d##r = multiply(d##r, x, w1);                         \
    x = _mm512_set1_ps(a[(a_next) + (r) * (a_row)]);      \
    e##r = multiply(e##r, x, w0);                         \
    f##r = multiply(f##r, x, w1);

#define GSF__LINEAR_FOUR(multiply)                                                                                      \
    const int64_t a_next = GSF__TILE_ROWS * count, b_next = GSF__TILE_COLUMNS * count;                                  \
    const int64_t share = gsf__ceil_div(ahead_count, count); /* one per step: the processor drops most of a burst */    \
    float* right = sums + next;                                                                                         \
    for (int i = 0; i < 2 * GSF__TILE_SUMS; i += 16) {                                                                  \
        _mm_prefetch((const char*)(sums + i), _MM_HINT_T0);                                                             \
        _mm_prefetch((const char*)(right + i), _MM_HINT_T0);                                                            \
    }                                                                                                                   \
    GSF__SIX(GSF__FOUR_ZEROS)                                                                                     \
    GSF__FOUR_TILES(multiply, GSF__LINEAR_AHEAD, a, 1, GSF__TILE_ROWS, a_next, b, b_next, count)                        \
    GSF__SIX(GSF__FOUR_STORE)
#define GSF__LINEAR_AHEAD                              \
    _mm_prefetch((const char*)ahead, _MM_HINT_T1);     \
    ahead += share;

GSF__INLINE_AVX512 __m512 gsf__nn_add_product(__m512 sum, __m512 a, __m512 b) { return _mm512_fmadd_ps(a, b, sum); }

// Each sum adds its products in the order of gsf__tile_avx2, so the results are bit-identical.
GSF__TARGET_AVX512 static void gsf__four_tiles_avx512(const float* a, const float* b, int64_t count, int add, float* sums,
                                                      int64_t next, const float* ahead, int64_t ahead_count) {
    GSF__LINEAR_FOUR(gsf__nn_add_product)
}

GSF__INLINE_AVX512 __m512 gsf__load16(const char* p, gsf_nn_dtype dtype) { // sixteen weights, widened
    if (dtype == GSF_NN_F32) return _mm512_loadu_ps((const float*)(const void*)p);
    const __m256i bits = _mm256_loadu_si256((const __m256i*)(const void*)p);
    if (dtype == GSF_NN_F16) return _mm512_cvtph_ps(bits);
    return _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(bits), 16));
}

// One row of weights times one row of x: sequential reads suit the hardware prefetcher. `count` is a multiple of 32.
GSF__INLINE_AVX512 float gsf__gemv_one16(const char* w, gsf_nn_dtype dtype, const float* x, int64_t count) {
    const int64_t vector = dtype == GSF_NN_F32 ? 64 : 32; // bytes
    __m512 s0 = _mm512_setzero_ps(), s1 = s0, s2 = s0, s3 = s0;
    for (; count >= 64; count -= 64, x += 64, w += 4 * vector) {
        s0 = _mm512_fmadd_ps(gsf__load16(w, dtype), _mm512_load_ps(x), s0);
        s1 = _mm512_fmadd_ps(gsf__load16(w + vector, dtype), _mm512_load_ps(x + 16), s1);
        s2 = _mm512_fmadd_ps(gsf__load16(w + 2 * vector, dtype), _mm512_load_ps(x + 32), s2);
        s3 = _mm512_fmadd_ps(gsf__load16(w + 3 * vector, dtype), _mm512_load_ps(x + 48), s3);
    }
    if (count > 0) {
        s0 = _mm512_fmadd_ps(gsf__load16(w, dtype), _mm512_load_ps(x), s0);
        s1 = _mm512_fmadd_ps(gsf__load16(w + vector, dtype), _mm512_load_ps(x + 16), s1);
    }
    return gsf__v_sum_avx512((s0 + s1) + (s2 + s3));
}

// Four rows of weights times two rows of x, laid out as [k / 16][2][16], added to sums[4][2]. `count` is a multiple of
// 32. The more arithmetic per load, the less far the hardware runs ahead, so this prefetches `ahead` bytes ahead.
GSF__INLINE_AVX512 void gsf__gemv_two16(const char* const w[4], gsf_nn_dtype dtype, size_t ahead, const float* x,
                                        int64_t count, float* sums) {
    const char *w0 = w[0], *w1 = w[1], *w2 = w[2], *w3 = w[3];
    const int64_t vector = dtype == GSF_NN_F32 ? 64 : 32; // bytes
#define GSF_ROWS(X) X(0) X(1) X(2) X(3)
#define GSF_X(r) __m512 s##r##0 = _mm512_setzero_ps(), s##r##1 = s##r##0, t##r##0 = s##r##0, t##r##1 = s##r##0;
    GSF_ROWS(GSF_X)
#undef GSF_X
    for (int64_t at = 0; count > 0; count -= 32, at += 2 * vector, x += 64) {
        const __m512 x0 = _mm512_load_ps(x), x1 = _mm512_load_ps(x + 16);
        const __m512 y0 = _mm512_load_ps(x + 32), y1 = _mm512_load_ps(x + 48);
        __m512 v;
#define GSF_X(r)                                                                \
        _mm_prefetch(w##r + at + ahead, _MM_HINT_T0);                           \
        v = gsf__load16(w##r + at, dtype);                                      \
        s##r##0 = _mm512_fmadd_ps(v, x0, s##r##0);                              \
        s##r##1 = _mm512_fmadd_ps(v, x1, s##r##1);                              \
        if (vector == 64) _mm_prefetch(w##r + at + ahead + 64, _MM_HINT_T0);    \
        v = gsf__load16(w##r + at + vector, dtype);                             \
        t##r##0 = _mm512_fmadd_ps(v, y0, t##r##0);                              \
        t##r##1 = _mm512_fmadd_ps(v, y1, t##r##1);
        GSF_ROWS(GSF_X)
#undef GSF_X
    }
#define GSF_X(r)                                           \
    sums[2 * r] += gsf__v_sum_avx512(s##r##0 + t##r##0);       \
    sums[2 * r + 1] += gsf__v_sum_avx512(s##r##1 + t##r##1);
    GSF_ROWS(GSF_X)
#undef GSF_X
#undef GSF_ROWS
}

// Six rows of weights times four rows of x, as [k / 16][4][16], added to sums[6][4]; prefetches `ahead` bytes ahead.
GSF__INLINE_AVX512 void gsf__gemv_six16(const char* const w[6], gsf_nn_dtype dtype, size_t ahead, const float* x,
                                        int64_t count, float* sums) {
    const char *w0 = w[0], *w1 = w[1], *w2 = w[2], *w3 = w[3], *w4 = w[4], *w5 = w[5];
    const int64_t line = dtype == GSF_NN_F32 ? 16 : 32, vector = dtype == GSF_NN_F32 ? 64 : 32; // weights; bytes
#define GSF_X(r) __m512 s##r##0 = _mm512_setzero_ps(), s##r##1 = s##r##0, s##r##2 = s##r##0, s##r##3 = s##r##0;
    GSF__SIX(GSF_X)
#undef GSF_X
    for (int64_t at = 0; count > 0; count -= line) {
#define GSF_X(r) _mm_prefetch(w##r + at + ahead, _MM_HINT_T0);
        GSF__SIX(GSF_X)
#undef GSF_X
        for (int64_t i = 0; i < line; i += 16, at += vector, x += 64) {
            const __m512 x0 = _mm512_load_ps(x), x1 = _mm512_load_ps(x + 16);
            const __m512 x2 = _mm512_load_ps(x + 32), x3 = _mm512_load_ps(x + 48);
            __m512 v;
#define GSF_X(r)                                           \
            v = gsf__load16(w##r + at, dtype);             \
            s##r##0 = _mm512_fmadd_ps(v, x0, s##r##0);     \
            s##r##1 = _mm512_fmadd_ps(v, x1, s##r##1);     \
            s##r##2 = _mm512_fmadd_ps(v, x2, s##r##2);     \
            s##r##3 = _mm512_fmadd_ps(v, x3, s##r##3);
            GSF__SIX(GSF_X)
#undef GSF_X
        }
    }
#define GSF_X(r)                                  \
    sums[4 * r] += gsf__v_sum_avx512(s##r##0);        \
    sums[4 * r + 1] += gsf__v_sum_avx512(s##r##1);    \
    sums[4 * r + 2] += gsf__v_sum_avx512(s##r##2);    \
    sums[4 * r + 3] += gsf__v_sum_avx512(s##r##3);
    GSF__SIX(GSF_X)
#undef GSF_X
}

// Weights are read fastest as long sequential streams: the columns are divided into as many parts as are read at once,
// and each part is read from end to end. Only if x, far larger than the weights next to it, would not stay in the L1
// cache (four rows and 16-bit weights) is it processed in steps; neighbouring columns are then read together and the
// next ones prefetched.
GSF__INLINE_AVX512 void gsf__gemv16(const gsf__linear_job* job, gsf_nn_dtype dtype, size_t size, int64_t rows,
                                    int64_t column, int64_t columns, float* sums, int64_t pitch) {
    const int64_t taken = rows == 1 ? 1 : rows == 2 ? 4 : 6, turns = gsf__ceil_div(columns, taken);
    const int streams = rows <= 2 || size == 4;
    const int64_t apart = streams ? turns : 1, next = streams ? 1 : taken;
    const int64_t step = streams ? job->in : (int64_t)GSF__GEMV_STEP;
    const size_t bytes = (size_t)job->in * size;
    const size_t ahead = !streams    ? (size_t)taken * bytes
                         : size == 4 ? (size_t)GSF__GEMV_AHEAD
                                     : (size_t)GSF__GEMV_AHEAD16;
    const char* first = (const char*)job->desc.weight->data + (size_t)column * bytes;
    char tails[6][4 * GSF__GEMV_PAD];
    memset(tails, 0, sizeof tails);
    for (int64_t m = 0; m < job->desc.rows; m++) memset(sums + m * pitch, 0, (size_t)columns * sizeof(float));
    for (int64_t k = 0; k < job->in; k += step) {
        const int64_t count = gsf__least(step, job->in - k), whole = count / GSF__GEMV_PAD * GSF__GEMV_PAD;
        const size_t left = (size_t)(count - whole) * size;
        for (int64_t turn = 0; turn < turns; turn++) {
            float tile[6 * GSF__GEMV_ROWS]; // [weights][x]
            const char* w[6];
            memset(tile, 0, sizeof tile);
            for (int64_t r = 0; r < taken; r++)
                w[r] = first + (size_t)gsf__least(turn * next + r * apart, columns - 1) * bytes + (size_t)k * size;
            for (int part = 0; part < (left ? 2 : 1); part++) { // the second part: the remainder, padded with zeros
                const float* x = job->gemv_x + (k + part * whole) * rows;
                const int64_t n = part ? (int64_t)GSF__GEMV_PAD : whole;
                for (int64_t r = 0; part && r < taken; r++) {
                    memcpy(tails[r], w[r] + (size_t)whole * size, left);
                    w[r] = tails[r];
                }
                if (rows == 1) tile[0] += gsf__gemv_one16(w[0], dtype, x, n);
                else if (rows == 2) gsf__gemv_two16(w, dtype, ahead, x, n, tile);
                else gsf__gemv_six16(w, dtype, ahead, x, n, tile);
            }
            for (int64_t r = 0; r < taken && turn * next + r * apart < columns; r++)
                for (int64_t m = 0; m < job->desc.rows; m++)
                    sums[m * pitch + turn * next + r * apart] += tile[r * rows + m];
        }
    }
}

GSF__TARGET_AVX512 static void gsf__gemv_avx512(const gsf__linear_job* job, int64_t column, int64_t columns, float* sums,
                                                int64_t pitch) {
    const int64_t rows = gsf__gemv_rows(job->desc.rows);
#define GSF_X(dtype, size)                                                                  \
    if (rows == 1) gsf__gemv16(job, dtype, size, 1, column, columns, sums, pitch);          \
    else if (rows == 2) gsf__gemv16(job, dtype, size, 2, column, columns, sums, pitch);     \
    else gsf__gemv16(job, dtype, size, GSF__GEMV_ROWS, column, columns, sums, pitch);
    switch (job->desc.weight->dtype) {
        case GSF_NN_F32: GSF_X(GSF_NN_F32, 4) break;
        case GSF_NN_BF16: GSF_X(GSF_NN_BF16, 2) break;
        default: GSF_X(GSF_NN_F16, 2) break;
    }
#undef GSF_X
}

static const gsf__linear_kernels gsf__linear_avx512 = {gsf__pack_weights_avx2, gsf__pack_rows_avx2, gsf__tile_avx2,
                                                       gsf__four_tiles_avx512, gsf__epilogue_avx512, gsf__gemv_avx512,
                                                       16, 1};

// ---- linear: kernels for pairs of bf16

// The weights are already stored as pairs.
static void gsf__pack_weights_bf16(const char* w, gsf_nn_dtype dtype, size_t pitch, int64_t columns, int64_t count,
                                   float* out) {
    (void)dtype;
    gsf__pack_weights_avx2(w, GSF_NN_F32, pitch, columns, count, out);
}

// Eight units of a row with `values` values, from value `first` on; zeros beyond the end.
GSF__INLINE_BF16 __m256 gsf__bf16_units(const float* row, int64_t first, int64_t values) {
    const __m512 v = _mm512_maskz_loadu_ps(gsf__nn_mask16(values > first ? values - first : 0), row + first);
    return _mm256_castsi256_ps(gsf__nn_round_bf16(v));
}

GSF__TARGET_BF16 static void gsf__pack_rows_bf16(const float* x, int64_t ldx, int64_t rows, int64_t count, float* out) {
    float tile[8 * GSF__TILE_ROWS + 2];
    for (int64_t k = 0; k < count; k += 8, out += 8 * GSF__TILE_ROWS) {
#define GSF_X(i) gsf__bf16_units(x + (i) * ldx, 2 * k, i < rows ? 2 * count : 0)
        __m256 r[8] = {GSF_X(0), GSF_X(1), GSF_X(2),            GSF_X(3),
                       GSF_X(4), GSF_X(5), _mm256_setzero_ps(), _mm256_setzero_ps()};
#undef GSF_X
        float* to = k + 8 <= count ? out : tile;
        gsf__nn_store_columns(r, to, GSF__TILE_ROWS); // as in gsf__pack_rows_avx2
        if (to == tile) memcpy(out, tile, (size_t)((count - k) * GSF__TILE_ROWS) * sizeof(float));
    }
}

GSF__INLINE_BF16 void gsf__nn_tile_bf16(const float* a, int64_t a_row, int64_t a_step, const float* b, int64_t count,
                                        __m512 c[GSF__TILE_ROWS]) {
    __m512 c0 = _mm512_setzero_ps(), c1 = c0, c2 = c0, c3 = c0, c4 = c0, c5 = c0;
    for (; count > 0; count--, a += a_step, b += GSF__TILE_COLUMNS) {
        const __m512 w = _mm512_loadu_ps(b);
#define GSF_X(r) c##r = gsf__nn_add_pairs(c##r, _mm512_set1_ps(a[(r) * a_row]), w);
        GSF__SIX(GSF_X)
#undef GSF_X
    }
    c[0] = c0; c[1] = c1; c[2] = c2; c[3] = c3; c[4] = c4; c[5] = c5;
}

GSF__TARGET_BF16 static void gsf__tile_bf16(const float* a, const float* b, int64_t count, int add, float* sums,
                                            const float* ahead, int64_t ahead_count) {
    __m512 c[GSF__TILE_ROWS];
    for (int64_t i = 0; i < ahead_count; i += 16) _mm_prefetch((const char*)(ahead + i), _MM_HINT_T1);
    gsf__nn_tile_bf16(a, 1, GSF__TILE_ROWS, b, count, c);
#define GSF_X(i) GSF__FOUR_PUT(sums + 16 * (i), c[i])
    GSF__SIX(GSF_X)
#undef GSF_X
}

GSF__TARGET_BF16 static void gsf__four_tiles_bf16(const float* a, const float* b, int64_t count, int add, float* sums,
                                                  int64_t next, const float* ahead, int64_t ahead_count) {
    GSF__LINEAR_FOUR(gsf__nn_add_pairs)
}

static const gsf__linear_kernels gsf__linear_bf16 = {gsf__pack_weights_bf16, gsf__pack_rows_bf16, gsf__tile_bf16,
                                                     gsf__four_tiles_bf16, gsf__epilogue_avx512, gsf__gemv_avx512, 16, 2};

#endif

static const gsf__linear_kernels* gsf__linear_kernels_of(gsf_cpu_level level, int pairs) { // pairs: prefer bf16
#if GSF__X86
    if (level >= GSF_CPU_AVX512_BF16 && pairs) return &gsf__linear_bf16;
    if (level >= GSF_CPU_AVX512) return &gsf__linear_avx512;
    if (level >= GSF_CPU_AVX2) return &gsf__linear_avx2;
#endif
    (void)level;
    (void)pairs;
    return &gsf__linear_scalar;
}

// ---- linear: blocks and scheduling

// The panel that starts at output `at` of the group, at step k: panels of one step are adjacent.
static float* gsf__packed_panel(const gsf__linear_job* job, int64_t at, int64_t k, int64_t count) {
    return job->packed + k * gsf__round_up(job->columns, GSF__TILE_COLUMNS) + at * count;
}

static void gsf__linear_pack_panel(void* arg, size_t panel, int32_t worker) { // of the current group, its full depth
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const gsf_nn_tensor* w = job->desc.weight;
    const int64_t at = (int64_t)panel * GSF__TILE_COLUMNS, width = gsf__least(job->columns - at, GSF__TILE_COLUMNS);
    const size_t size = gsf_nn_get_dtype_size(w->dtype), pitch = (size_t)job->in * size;
    const char* from = (const char*)w->data + (size_t)(job->first + at) * pitch;
    (void)worker;
    for (int64_t k = 0; k < job->length; k += job->plan.depth) {
        const int64_t count = gsf__least(job->length - k, job->plan.depth);
        float* to = gsf__packed_panel(job, at, k, count);
        job->kernels->pack_weights(from + (size_t)(k * job->kernels->unit) * size, w->dtype, pitch, width, count, to);
    }
}

// All tiles of one or two panels at one step; `next` is the distance between the sums of the two.
static void gsf__linear_panels(const gsf__linear_job* job, const float* x, const float* w, float* sums, int64_t next,
                               int64_t k, int64_t count, int64_t row, int64_t rows, int64_t column, int64_t columns) {
    const gsf__linear_kernels* kernels = job->kernels;
    const int64_t panels = gsf__ceil_div(columns, GSF__TILE_COLUMNS), groups = gsf__ceil_div(rows, GSF__TILE_ROWS);
    const float* ahead = w + panels * count * GSF__TILE_COLUMNS; // usually the panels after these
    const int64_t share = job->plan.lone ? 0 : gsf__round_up(gsf__ceil_div(panels * count * GSF__TILE_COLUMNS, groups), 16);
    for (int64_t g = 0, step; g < groups; g += step) {
        const float* a = x + g * GSF__TILE_ROWS * count;
        float* s = sums + g * GSF__TILE_SUMS;
        step = kernels->four_tiles && panels == 2 && g + 2 <= groups ? 2 : 1;
        if (step == 2) kernels->four_tiles(a, w, count, k > 0, s, next, ahead + g * share, 2 * share);
        for (int64_t p = 0; step == 1 && p < panels; p++)
            kernels->tile(a, w + p * count * GSF__TILE_COLUMNS, count, k > 0, s + p * next, ahead + g * share,
                          p == 0 ? share : 0);
        if (k + count < job->length) continue;
        for (int64_t t = 0; t < step * panels; t++) {
            const int64_t p = t / step, r = (g + t % step) * GSF__TILE_ROWS, c = p * GSF__TILE_COLUMNS;
            kernels->epilogue(job, sums + p * next + r * GSF__TILE_COLUMNS, GSF__TILE_COLUMNS, row + r,
                              gsf__least(rows - r, GSF__TILE_ROWS), column + c, gsf__least(columns - c, GSF__TILE_COLUMNS));
        }
    }
}

static void gsf__linear_block(void* arg, size_t index, int32_t worker) { // a block of rows and outputs
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const gsf__linear_plan* plan = &job->plan;
    const gsf__nn_linear_desc* d = &job->desc;
    const int64_t row = (int64_t)index % plan->row_blocks * plan->block_rows;
    const int64_t at = (int64_t)index / plan->row_blocks * plan->block_columns; // within the group
    const int64_t rows = gsf__least(d->rows - row, plan->block_rows);
    const int64_t columns = gsf__least(job->columns - at, plan->block_columns);
    const int64_t groups = gsf__ceil_div(rows, GSF__TILE_ROWS);
    const size_t size = gsf_nn_get_dtype_size(d->weight->dtype), pitch = (size_t)job->in * size;
    float* sums = job->workers + (size_t)worker * plan->per_worker;
    float* panel = sums + plan->block_rows * plan->block_columns; // both are padded to whole tiles
    float* x = panel + (plan->lone ? plan->depth * GSF__LINEAR_PAIR : 0);
    for (int64_t k = 0; k < job->length; k += plan->depth) {
        const int64_t count = gsf__least(job->length - k, plan->depth), value = k * job->kernels->unit;
        for (int64_t r = 0; r < rows; r += GSF__TILE_ROWS)
            job->kernels->pack_rows(d->x + (row + r) * d->ldx + value, d->ldx, gsf__least(rows - r, GSF__TILE_ROWS), count,
                                    x + r * count);
        for (int64_t c = 0; c < columns; c += GSF__LINEAR_PAIR) {
            const int64_t width = gsf__least(columns - c, GSF__LINEAR_PAIR), next = groups * GSF__TILE_SUMS;
            const int64_t column = job->first + at + c;
            const float* w = plan->lone ? panel : gsf__packed_panel(job, at + c, k, count);
            for (int64_t p = 0; plan->lone && p < width; p += GSF__TILE_COLUMNS)
                job->kernels->pack_weights((const char*)d->weight->data + (size_t)(column + p) * pitch + (size_t)value * size,
                                           d->weight->dtype, pitch, gsf__least(width - p, GSF__TILE_COLUMNS), count,
                                           panel + p * count);
            gsf__linear_panels(job, x, w, sums + c / GSF__TILE_COLUMNS * next, next, k, count, row, rows, column, width);
        }
    }
}

static void gsf__linear_gemv(void* arg, size_t index, int32_t worker) { // some outputs, all rows
    const gsf__linear_job* job = (const gsf__linear_job*)arg;
    const int64_t at = (int64_t)index * job->plan.block_columns;
    const int64_t columns = gsf__least(job->out - at, job->plan.block_columns);
    float* sums = job->workers + (size_t)worker * job->plan.per_worker;
    job->kernels->gemv(job, at, columns, sums, job->plan.block_columns);
    job->kernels->epilogue(job, sums, job->plan.block_columns, 0, job->desc.rows, at, columns);
}

// Rearranges x for the GEMV kernels, padded with zeros.
static void gsf__gemv_order(gsf__linear_job* job) {
    const gsf__nn_linear_desc* d = &job->desc;
    const int64_t rows = gsf__gemv_rows(d->rows), lanes = job->kernels->gemv_lanes;
    float* to = job->gemv_x;
    for (int64_t first = 0; lanes > 0 && first < job->in; first += lanes)
        for (int64_t m = 0; m < rows; m++)
            for (int64_t k = first; k < first + lanes; k++) *to++ = m < d->rows && k < job->in ? d->x[m * d->ldx + k] : 0.0f;
    float* end = job->gemv_x + gsf__round_up(job->in, GSF__GEMV_PAD) * rows;
    while (lanes > 0 && to < end) *to++ = 0.0f;
}

// Plans (rows, in) x (out, in)^T; returns 0 if the size of the scratch memory overflows.
static int gsf__plan_linear(int64_t rows, int64_t in, int64_t out, size_t weight_size, gsf__linear_plan* plan) {
    memset(plan, 0, sizeof *plan);
    if (in > INT64_MAX / 256 || out > INT64_MAX / 256 || rows > INT64_MAX / 256) return 0;
    size_t shared = 0;
    if (rows <= GSF__GEMV_ROWS) {
        const int64_t least = GSF__GEMV_BYTES / (in * (int64_t)weight_size) + 1, share = gsf__ceil_div(out, GSF__GEMV_CHUNKS);
        plan->gemv = 1;
        plan->block_columns = gsf__round_up(gsf__least(share < least ? least : share, GSF__GEMV_COLUMNS), GSF__GEMV_UNIT);
        plan->per_worker = (size_t)(plan->block_columns * GSF__GEMV_ROWS);
        shared = (size_t)gsf__round_up(in, GSF__GEMV_PAD) * GSF__GEMV_ROWS;
    } else {
        plan->lone = rows <= GSF__LINEAR_LONE_ROWS;
        plan->depth = gsf__even_piece(in, GSF__LINEAR_DEPTH, 8);
        plan->block_rows = gsf__even_piece(rows, plan->lone ? GSF__LINEAR_LONE_ROWS : GSF__LINEAR_ROWS, 2 * GSF__TILE_ROWS);
        plan->row_blocks = gsf__ceil_div(rows, plan->block_rows);
        const int64_t most = GSF__LINEAR_PACKED / in / GSF__TILE_COLUMNS * GSF__TILE_COLUMNS;
        const int64_t widest = plan->lone ? GSF__LINEAR_LONE_COLUMNS : GSF__LINEAR_COLUMNS;
        plan->group_columns = plan->lone ? out : gsf__even_piece(out, most < 16 ? 16 : most, GSF__TILE_COLUMNS);
        plan->block_columns = gsf__even_piece(plan->group_columns, widest, GSF__LINEAR_PAIR);
        plan->per_worker = (size_t)(plan->block_rows * (plan->block_columns + plan->depth) + GSF__TILE_COLUMNS);
        const int64_t packed = gsf__round_up(plan->group_columns, GSF__TILE_COLUMNS);
        if (plan->lone) plan->per_worker += (size_t)(plan->depth * GSF__LINEAR_PAIR);
        else if (!gsf__mul_size((size_t)packed, (size_t)in, &shared)) return 0;
    }
    plan->per_worker = (size_t)gsf__round_up((int64_t)plan->per_worker, 16); // workers start on cache lines
    plan->shared = shared + (size_t)gsf__round_up(out + 16, 16);
    return plan->shared >= shared;
}

static gsf_result gsf__check_linear(gsf_context* ctx, const gsf__nn_linear_desc* desc, int64_t* in, int64_t* out) {
    const gsf_nn_tensor* w = desc->weight;
    if (!desc->x || !desc->y || !w || !w->data || desc->rows < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: x, y or weight is missing");
    const char* name = w->name ? w->name : "weight";
    if (w->rank < 2 || w->shape[0] < 1 || w->count / w->shape[0] < 1 || w->count % w->shape[0])
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: %s is not a matrix", name);
    if (w->dtype != GSF_NN_F32 && w->dtype != GSF_NN_BF16 && w->dtype != GSF_NN_F16)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "linear: %s is %s", name, gsf__nn_dtype_name(w->dtype));
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

static void gsf__run_linear(gsf_context* ctx, gsf__linear_job* job) { // scratch is allocated already
    const gsf__linear_plan* plan = &job->plan;
    memset(job->bias, 0, (size_t)(job->out + 16) * sizeof(float));
    if (job->desc.bias) gsf_nn_convert_tensor(job->desc.bias, 0, job->out, job->bias);
    if (plan->gemv) {
        gsf__gemv_order(job);
        gsf__parallel_for(ctx, (size_t)gsf__ceil_div(job->out, plan->block_columns), gsf__linear_gemv, job);
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

// A linear layer with its activation and residual. `workspace` NULL: scratch is allocated for this call only.
static gsf_result gsf__nn_run_linear(gsf_context* ctx, gsf__nn_workspace* workspace, const gsf__nn_linear_desc* desc) {
    gsf__nn_workspace own;
    gsf__linear_job job;
    size_t floats, bytes;
    memset(&own, 0, sizeof own);
    memset(&job, 0, sizeof job);
    GSF__TRY(gsf__check_linear(ctx, desc, &job.in, &job.out));
    if (desc->rows == 0) return GSF_OK;
    job.desc = *desc;
    if (!job.desc.ldx) job.desc.ldx = job.in;
    if (!job.desc.ldy) job.desc.ldy = job.out;
    const int gemv = desc->rows <= GSF__GEMV_ROWS;
    const int pairs = desc->bf16 && desc->weight->dtype == GSF_NN_BF16 && job.in % 2 == 0;
    job.kernels = gsf__linear_kernels_of(ctx->cpu_level, pairs && !gemv);
    job.length = job.in / job.kernels->unit;
    if (!gsf__plan_linear(desc->rows, job.length, job.out, gsf_nn_get_dtype_size(desc->weight->dtype), &job.plan) ||
        !gsf__mul_size(job.plan.per_worker, (size_t)ctx->parallel.worker_count, &floats) ||
        floats > SIZE_MAX - job.plan.shared || !gsf__mul_size(floats + job.plan.shared, sizeof(float), &bytes))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "linear: %lld rows x %lld x %lld", (long long)desc->rows,
                        (long long)job.in, (long long)job.out);
    float* scratch = (float*)gsf__nn_scratch(ctx, workspace ? workspace : &own, bytes);
    if (!scratch) return GSF_ERROR_OUT_OF_MEMORY;
    job.workers = scratch;
    job.bias = scratch + floats;
    job.packed = job.gemv_x = job.bias + gsf__round_up(job.out + 16, 16);
    gsf__run_linear(ctx, &job);
    gsf__nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn int8 ------------------------------------------------------------------
//
// Linear layers in 8-bit integers: y[m][n] = sx[m] sw[n] sum_k qx[m][k] qw[n][k], with q = round(value / s) and s = the
// row's largest magnitude / 127. One outlier makes s large and all other values inexact, so both operands are first
// rotated in blocks: with H the Hadamard matrix of n x n signs, (H x) . (H w) = n x . w, and an outlier is spread over
// its block (QuaRot, Ashkboos et al. 2024). H is applied without its 1/sqrt(n); sw includes the 1/n, a power of two, so
// this adds no rounding.
//
//     qw [panel of 16 outputs][k/4][16][4] int8         qx [group of 6 rows][k/4][6][4] int16, or uint8
//
// Up to 4 rows, then in groups of 2 or 4, are multiplied with the 8-bit weights as they are read, one panel after
// another. Dot-product instructions (VNNI) take fours of unsigned by signed bytes: for them qx is stored as qx + 128,
// and 128 sum_k qw is subtracted from the sums, which may wrap around on the way. As with floats, two groups by two
// panels. AVX2 has no such instruction, and its byte products add pairs in 16 bits, which 2 * 127 * 127 just fits:
// moving the signs to one operand, multiply, widen and add are 4 instructions for 32 products. With both operands
// widened to 16 bits (a panel once per block) it takes 2 multiplications (vpmaddwd) and 2 additions, also 4, but only
// the 12 sums need registers; measured alone in L1, 146 against 115 Gop/s per core. Either way, two multiplications per
// cycle limit it to twice the multiply-adds of float; exceeding that takes the dot-product instructions. Sums are
// integers: bit-identical for any division of the work, instruction set and number of workers.

enum {
    GSF__INT8_BLOCK = 256,    // longest rotation
    GSF__INT8_DEPTH = 512,    // step in the inner dimension: a widened panel is 16 KiB; doubled if not widened
    GSF__INT8_ROWS = 192,     // of a block; times depth: 192 KiB
    GSF__INT8_COLUMNS = 384,  // of a block; its sums: 288 KiB
    GSF__INT8_AHEAD = 4096,   // prefetch distance of the weights in bytes
    GSF__INT8_LONGEST = 131072 // 127 * 127 times this is below 2^31
};

#ifndef GSF__INT8_HELD // a test lowers it
#define GSF__INT8_HELD ((int64_t)1 << 24) // maximum number of 8-bit activations in memory, 2 bytes each
#endif

typedef struct gsf__int8_kernels { // one set per instruction set
    // Rotates blocks of `block` of the `count` values in place; returns their largest magnitude (inf if NaN or inf)
    float (*rotate)(float* x, int64_t count, int64_t block);
    // Writes round(x * factor) as int16 in fours that are `pitch` apart; count is a multiple of 4
    void (*quantize)(const float* x, int64_t count, float factor, void* out, int64_t pitch);
    // The same, in the type that `tile` takes for x, x_size bytes per value
    void (*quantize_x)(const float* x, int64_t count, float factor, void* out, int64_t pitch);
    size_t x_size;
    // w [k/4][16][4] to out [2][k/4][8][4]; NULL: `tile` takes w unchanged
    void (*widen)(const int8_t* w, int64_t count, int16_t* out);
    // sums[6][16] = a [k/4][6][4] times b, or += with `add`
    void (*tile)(const void* a, const void* b, int64_t count, int add, int32_t* sums);
    // The same for two groups, `a_next` bytes apart, and two panels, `b_next` bytes apart, with sums `next` apart; may
    // be NULL. Also prefetches `ahead_count` bytes that are needed next.
    void (*four_tiles)(const void* a, int64_t a_next, const int8_t* b, int64_t b_next, int64_t count, int add, int32_t* sums,
                       int64_t next, const int8_t* ahead, int64_t ahead_count);
    // sums[rows][16] = a [k/4][rows][4], up to gemv_rows rows, times w [k/4][16][4]
    void (*gemv)(const void* a, int64_t rows, const int8_t* w, int64_t count, int32_t* sums);
    int64_t gemv_rows;
    // out[6][16] = (sums - offsets[16], if qx is unsigned) * rows[6] * columns[16]
    void (*scale)(const int32_t* sums, const int32_t* offsets, const float* rows, const float* columns, float* out);
} gsf__int8_kernels;

typedef struct gsf__int8_job {
    gsf__linear_job linear;      // desc and bias, for the epilogue
    const gsf__int8_kernels* kernels;
    const gsf__nn_quantized* weight;
    int64_t padded;              // `in` rounded up to a multiple of 4
    int64_t depth, block_rows, block_columns, row_blocks;
    int64_t held, first, rows;   // number of rows of x quantised at a time; the current rows
    char* x;
    float* scales;               // of the current rows
    char* workers;
    size_t per_worker;           // bytes
} gsf__int8_job;

// ---- int8: scalar kernels

static void gsf__int8_butterflies(float* x, int64_t block, int64_t half) { // one of log2(block) steps
    for (int64_t i = 0; i < block; i += 2 * half)
        for (int64_t j = i; j < i + half; j++) {
            const float a = x[j], b = x[j + half];
            x[j] = a + b;
            x[j + half] = a - b;
        }
}

static uint32_t gsf__int8_top(const float* x, int64_t count, uint32_t top) { // bits order magnitudes: inf, NaN last
    for (int64_t i = 0; i < count; i++) {
        uint32_t bits;
        memcpy(&bits, x + i, sizeof bits);
        bits &= 0x7fffffffu;
        if (bits > top) top = bits;
    }
    return top;
}

static float gsf__int8_size(uint32_t top) {
    float size;
    if (top > 0x7f800000u) top = 0x7f800000u;
    memcpy(&size, &top, sizeof size);
    return size;
}

static float gsf__int8_rotate_scalar(float* x, int64_t count, int64_t block) {
    for (int64_t i = 0; block > 1 && i < count; i += block)
        for (int64_t half = 1; half < block; half *= 2) gsf__int8_butterflies(x + i, block, half);
    return gsf__int8_size(gsf__int8_top(x, count, 0));
}

static void gsf__int8_quantize_scalar(const float* x, int64_t count, float factor, void* out, int64_t pitch) {
    const float rounder = 12582912.0f; // 1.5 * 2^23: adding it rounds to integers, ties to even
    int16_t* to = (int16_t*)out;
    for (int64_t k = 0; k < count; k++) to[(k >> 2) * pitch + (k & 3)] = (int16_t)((x[k] * factor + rounder) - rounder);
}

static void gsf__int8_widen_scalar(const int8_t* w, int64_t count, int16_t* out) {
    for (int64_t k = 0; k < count; k++)
        for (int64_t c = 0; c < GSF__TILE_COLUMNS; c++)
            out[(c >> 3) * 8 * count + (k >> 2) * 32 + (c & 7) * 4 + (k & 3)] = w[(k >> 2) * 64 + c * 4 + (k & 3)];
}

static void gsf__int8_tile_scalar(const void* a, const void* b, int64_t count, int add, int32_t* sums) {
    const int16_t *rows = (const int16_t*)a, *panel = (const int16_t*)b;
    if (!add) memset(sums, 0, GSF__TILE_SUMS * sizeof *sums);
    for (int64_t k = 0; k < count; k += 4, rows += 4 * GSF__TILE_ROWS)
        for (int64_t i = 0; i < GSF__TILE_ROWS; i++)
            for (int64_t j = 0; j < GSF__TILE_COLUMNS; j++) {
                const int16_t *p = rows + 4 * i, *q = panel + (j >> 3) * 8 * count + 8 * k + 4 * (j & 7);
                sums[i * GSF__TILE_COLUMNS + j] += p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
            }
}

static void gsf__int8_gemv_scalar(const void* a, int64_t rows, const int8_t* w, int64_t count, int32_t* sums) {
    const int16_t* x = (const int16_t*)a;
    memset(sums, 0, (size_t)(rows * GSF__TILE_COLUMNS) * sizeof *sums);
    for (int64_t k = 0; k < count; k += 4, x += 4 * rows, w += 4 * GSF__TILE_COLUMNS)
        for (int64_t i = 0; i < rows; i++)
            for (int64_t j = 0; j < GSF__TILE_COLUMNS; j++) {
                const int16_t* p = x + 4 * i;
                const int8_t* q = w + 4 * j;
                sums[i * GSF__TILE_COLUMNS + j] += p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
            }
}

static void gsf__int8_scale_scalar(const int32_t* sums, const int32_t* offsets, const float* rows, const float* columns,
                                   float* out) {
    (void)offsets;
    for (int i = 0; i < GSF__TILE_SUMS; i++)
        out[i] = (float)sums[i] * rows[i / GSF__TILE_COLUMNS] * columns[i % GSF__TILE_COLUMNS];
}

static const gsf__int8_kernels gsf__int8_scalar = {
    gsf__int8_rotate_scalar, gsf__int8_quantize_scalar, gsf__int8_quantize_scalar, sizeof(int16_t), gsf__int8_widen_scalar,
    gsf__int8_tile_scalar, NULL, gsf__int8_gemv_scalar, 2, gsf__int8_scale_scalar};

// The rotation.
#define GSF__KERNELS "gsfixer_nn.h"
#define GSF__KERNELS_INT8
#define GSF__KERNELS_AVX512
#include "gsfixer.h"
#undef GSF__KERNELS_INT8

#endif // GSF__ISA
#ifdef GSF__KERNELS_INT8
#if GSF__LANES > 1

// Two butterfly steps, of `half` and twice `half`, a multiple of GSF__LANES.
GSF__V_INLINE void GSF__V(gsf__int8_two_steps)(float* x, int64_t block, int64_t half) {
    for (int64_t i = 0; i < block; i += 4 * half)
        for (int64_t j = i; j < i + half; j += GSF__LANES) {
            const gsf__vf a = gsf__v_load(x + j), b = gsf__v_load(x + j + half);
            const gsf__vf c = gsf__v_load(x + j + 2 * half), d = gsf__v_load(x + j + 3 * half);
            const gsf__vf ab = a + b, cd = c + d, a_b = a - b, c_d = c - d;
            gsf__v_store(x + j, ab + cd);
            gsf__v_store(x + j + half, a_b + c_d);
            gsf__v_store(x + j + 2 * half, ab - cd);
            gsf__v_store(x + j + 3 * half, a_b - c_d);
        }
}

GSF__V_INLINE void GSF__V(gsf__int8_one_step)(float* x, int64_t block, int64_t half) {
    for (int64_t i = 0; i < block; i += 2 * half)
        for (int64_t j = i; j < i + half; j += GSF__LANES) {
            const gsf__vf a = gsf__v_load(x + j), b = gsf__v_load(x + j + half);
            gsf__v_store(x + j, a + b);
            gsf__v_store(x + j + half, a - b);
        }
}

GSF__V_KERNEL float GSF__V(gsf__int8_rotate)(float* x, int64_t count, int64_t block) {
    const int64_t stride = block > GSF__LANES ? block : GSF__LANES; // a vector may hold several blocks
    for (int64_t i = 0; i < count; i += stride) {
        float* p = x + i;
        int64_t half = GSF__LANES;
        for (int64_t j = 0; j < block; j += GSF__LANES) {
            const size_t left = (size_t)(count - i - j);
            if (block >= GSF__LANES) gsf__v_store(p + j, gsf__v_hadamard(gsf__v_load(p + j), GSF__LANES));
            else gsf__v_store_first(p + j, gsf__v_hadamard(gsf__v_load_first(p + j, left), block), left);
        }
        for (; 4 * half <= block; half *= 4) GSF__V(gsf__int8_two_steps)(p, block, half);
        if (half < block) GSF__V(gsf__int8_one_step)(p, block, half);
    }
    gsf__vi top = gsf__vi_set(0); // bits of magnitudes, see gsf__int8_top
    int64_t k = 0;
    for (; k + GSF__LANES <= count; k += GSF__LANES) top = gsf__vi_max(top, gsf__v_bits(gsf__v_abs(gsf__v_load(x + k))));
    if (k < count) top = gsf__vi_max(top, gsf__v_bits(gsf__v_abs(gsf__v_load_first(x + k, (size_t)(count - k)))));
    return gsf__int8_size((uint32_t)gsf__vi_largest(top));
}

#endif
#endif // GSF__KERNELS_INT8
#ifndef GSF__ISA

// ---- int8: AVX2 kernels

#if GSF__X86

GSF__TARGET_AVX2 static void gsf__int8_quantize_avx2(const float* x, int64_t count, float factor, void* out, int64_t pitch) {
    const __m256 f = _mm256_set1_ps(factor);
    int16_t* to = (int16_t*)out;
    int64_t k = 0;
    for (; k + 8 <= count; k += 8, to += 2 * pitch) {
        const __m256i v = _mm256_cvtps_epi32(_mm256_mul_ps(_mm256_loadu_ps(x + k), f));
        const __m128i q = _mm_packs_epi32(_mm256_castsi256_si128(v), _mm256_extracti128_si256(v, 1));
        _mm_storel_epi64((__m128i*)(void*)to, q);
        _mm_storel_epi64((__m128i*)(void*)(to + pitch), _mm_unpackhi_epi64(q, q));
    }
    if (k < count) gsf__int8_quantize_scalar(x + k, count - k, factor, to, pitch);
}

GSF__TARGET_AVX2 static void gsf__int8_widen_avx2(const int8_t* w, int64_t count, int16_t* out) {
    for (int64_t k = 0; k < count; k += 4, w += 64, out += 32)
        for (int i = 0; i < 4; i++) {
            const __m256i v = _mm256_cvtepi8_epi16(_mm_loadu_si128((const __m128i*)(const void*)(w + 16 * i)));
            _mm256_storeu_si256((__m256i*)(void*)(out + (i >> 1) * 8 * count + 16 * (i & 1)), v);
        }
}

GSF__INLINE_AVX2 __m256i gsf__int8_broadcast4(const int16_t* p) {
    int64_t four;
    memcpy(&four, p, sizeof four);
    return _mm256_set1_epi64x(four);
}

// Keeps gcc from reordering the additions, which would make it run out of registers.
#define GSF__INT8_ADD(sum, product)              \
    sum = _mm256_add_epi32(sum, product);        \
    __asm__("" : "+x"(sum));

GSF__TARGET_AVX2 static void gsf__int8_tile_avx2(const void* a, const void* b, int64_t count, int add, int32_t* sums) {
    for (int half = 0; half < 2; half++, sums += 8) {
        const int16_t *p = (const int16_t*)a, *q = (const int16_t*)b + half * 8 * count;
        // 12 registers of sums, each 4 columns by 2 pairs; 2 of b, 1 of a
        __m256i c00 = _mm256_setzero_si256(), c01 = c00, c10 = c00, c11 = c00, c20 = c00, c21 = c00;
        __m256i c30 = c00, c31 = c00, c40 = c00, c41 = c00, c50 = c00, c51 = c00;
        for (int64_t k = 0; k < count; k += 4, p += 24, q += 32) {
            const __m256i b0 = _mm256_loadu_si256((const __m256i*)(const void*)q);
            const __m256i b1 = _mm256_loadu_si256((const __m256i*)(const void*)(q + 16));
            __m256i v;
#define GSF_X(i)                                            \
            v = gsf__int8_broadcast4(p + 4 * i);            \
            GSF__INT8_ADD(c##i##0, _mm256_madd_epi16(v, b0)) \
            GSF__INT8_ADD(c##i##1, _mm256_madd_epi16(v, b1))
            GSF__SIX(GSF_X)
#undef GSF_X
        }
#define GSF_X(i)                                                                                                        \
        {                                                                                                               \
            __m256i* to = (__m256i*)(void*)(sums + GSF__TILE_COLUMNS * i);                                              \
            const __m256i v = _mm256_permute4x64_epi64(_mm256_hadd_epi32(c##i##0, c##i##1), 0xd8);                      \
            _mm256_storeu_si256(to, add ? _mm256_add_epi32(_mm256_loadu_si256(to), v) : v);                             \
        }
        GSF__SIX(GSF_X)
#undef GSF_X
    }
}

GSF__INLINE_AVX2 void gsf__int8_gemv_sums(__m256i a, __m256i b, int32_t* to) { // 8 columns by 2 pairs
    const __m256i v = _mm256_permute4x64_epi64(_mm256_hadd_epi32(a, b), 0xd8);
    _mm256_storeu_si256((__m256i*)(void*)to, v);
}

GSF__INLINE_AVX2 void gsf__int8_gemv8(const int16_t* a, int64_t rows, const int8_t* w, int64_t count, int32_t* sums) {
    __m256i c00 = _mm256_setzero_si256(), c01 = c00, c02 = c00, c03 = c00, c10 = c00, c11 = c00, c12 = c00, c13 = c00;
    for (int64_t k = 0; k < count; k += 4, a += 4 * rows, w += 64) {
        const __m256i a0 = gsf__int8_broadcast4(a), a1 = rows > 1 ? gsf__int8_broadcast4(a + 4) : a0;
        __m256i v;
        _mm_prefetch((const char*)w + GSF__INT8_AHEAD, _MM_HINT_T1); // twice: see gsf__gemv_fetch
        _mm_prefetch((const char*)w + 2 * GSF__INT8_AHEAD, _MM_HINT_T1);
#define GSF_X(i)                                                                                \
        v = _mm256_cvtepi8_epi16(_mm_loadu_si128((const __m128i*)(const void*)(w + 16 * i)));   \
        GSF__INT8_ADD(c0##i, _mm256_madd_epi16(v, a0))                                          \
        if (rows > 1) { GSF__INT8_ADD(c1##i, _mm256_madd_epi16(v, a1)) }
        GSF_X(0) GSF_X(1) GSF_X(2) GSF_X(3)
#undef GSF_X
    }
    gsf__int8_gemv_sums(c00, c01, sums);
    gsf__int8_gemv_sums(c02, c03, sums + 8);
    if (rows == 1) return;
    gsf__int8_gemv_sums(c10, c11, sums + 16);
    gsf__int8_gemv_sums(c12, c13, sums + 24);
}

GSF__TARGET_AVX2 static void gsf__int8_gemv_avx2(const void* a, int64_t rows, const int8_t* w, int64_t count,
                                                 int32_t* sums) {
    if (rows == 1) gsf__int8_gemv8((const int16_t*)a, 1, w, count, sums);
    else gsf__int8_gemv8((const int16_t*)a, 2, w, count, sums);
}

GSF__TARGET_AVX2 static void gsf__int8_scale_avx2(const int32_t* sums, const int32_t* offsets, const float* rows,
                                                  const float* columns, float* out) {
    (void)offsets;
    for (int i = 0; i < GSF__TILE_SUMS; i += 8) {
        const __m256 v = _mm256_cvtepi32_ps(_mm256_loadu_si256((const __m256i*)(const void*)(sums + i)));
        const __m256 row = _mm256_set1_ps(rows[i / GSF__TILE_COLUMNS]);
        _mm256_storeu_ps(out + i, _mm256_mul_ps(_mm256_mul_ps(v, row), _mm256_loadu_ps(columns + i % GSF__TILE_COLUMNS)));
    }
}

static const gsf__int8_kernels gsf__int8_avx2 = {
    gsf__int8_rotate_avx2, gsf__int8_quantize_avx2, gsf__int8_quantize_avx2, sizeof(int16_t), gsf__int8_widen_avx2,
    gsf__int8_tile_avx2, NULL, gsf__int8_gemv_avx2, 2, gsf__int8_scale_avx2};

// ---- int8: AVX-512 kernels with dot products of bytes

GSF__TARGET_AVX512 static void gsf__int8_quantize_x_vnni(const float* x, int64_t count, float factor, void* out,
                                                         int64_t pitch) {
    const __m512 f = _mm512_set1_ps(factor);
    const __m512i offset = _mm512_set1_epi32(128);
    uint8_t* to = (uint8_t*)out;
    for (int64_t k = 0; k < count; k += 16) {
        const __m512 v = _mm512_maskz_loadu_ps(gsf__nn_mask16(count - k), x + k);
        const __m128i q = _mm512_cvtepi32_epi8(_mm512_add_epi32(_mm512_cvtps_epi32(_mm512_mul_ps(v, f)), offset));
        uint32_t fours[4];
        _mm_storeu_si128((__m128i*)(void*)fours, q);
        for (int64_t i = 0; i < 4 && k + 4 * i < count; i++, to += pitch) memcpy(to, &fours[i], sizeof fours[i]);
    }
}

GSF__INLINE_AVX512 __m512i gsf__int8_four(const uint8_t* p) {
    int32_t four;
    memcpy(&four, p, sizeof four);
    return _mm512_set1_epi32(four);
}

#define GSF_PUT(to, v) _mm512_storeu_si512(to, add ? _mm512_add_epi32(_mm512_loadu_si512(to), v) : v);

GSF__TARGET_VNNI static void gsf__int8_tile_vnni(const void* a, const void* b, int64_t count, int add, int32_t* sums) {
    const uint8_t* x = (const uint8_t*)a;
    const int8_t* w = (const int8_t*)b;
#define GSF_X(i) __m512i c##i = _mm512_setzero_si512();
    GSF__SIX(GSF_X)
#undef GSF_X
    for (; count > 0; count -= 4, x += 4 * GSF__TILE_ROWS, w += 4 * GSF__TILE_COLUMNS) {
        const __m512i v = _mm512_loadu_si512(w);
#define GSF_X(i) c##i = _mm512_dpbusd_epi32(c##i, gsf__int8_four(x + 4 * (i)), v);
        GSF__SIX(GSF_X)
#undef GSF_X
    }
#define GSF_X(i) GSF_PUT(sums + GSF__TILE_COLUMNS * (i), c##i)
    GSF__SIX(GSF_X)
#undef GSF_X
}

GSF__TARGET_VNNI static void gsf__int8_four_tiles_vnni(const void* a, int64_t a_next, const int8_t* b, int64_t b_next,
                                                       int64_t count, int add, int32_t* sums, int64_t next,
                                                       const int8_t* ahead, int64_t ahead_count) {
    const uint8_t *x0 = (const uint8_t*)a, *x1 = x0 + a_next;
    const int64_t share = gsf__ceil_div(4 * ahead_count, count);
    int32_t* right = sums + next;
#define GSF_X(i) __m512i c##i = _mm512_setzero_si512(), d##i = c##i, e##i = c##i, f##i = c##i;
    GSF__SIX(GSF_X) // as in gsf__four_tiles_avx512
#undef GSF_X
    for (; count > 0; count -= 4, x0 += 4 * GSF__TILE_ROWS, x1 += 4 * GSF__TILE_ROWS, b += 4 * GSF__TILE_COLUMNS) {
        const __m512i w0 = _mm512_loadu_si512(b), w1 = _mm512_loadu_si512(b + b_next);
        __m512i v;
        _mm_prefetch((const char*)ahead, _MM_HINT_T1);
        ahead += share;
#define GSF_X(i)                                                                         \
        v = gsf__int8_four(x0 + 4 * (i));                                                \
        c##i = _mm512_dpbusd_epi32(c##i, v, w0);                                         \
        d##i = _mm512_dpbusd_epi32(d##i, v, w1);                                         \
        v = gsf__int8_four(x1 + 4 * (i));                                                \
        e##i = _mm512_dpbusd_epi32(e##i, v, w0);                                         \
        f##i = _mm512_dpbusd_epi32(f##i, v, w1);
        GSF__SIX(GSF_X)
#undef GSF_X
    }
#define GSF_X(i)                                                                         \
    GSF_PUT(sums + 16 * (i), c##i) GSF_PUT(right + 16 * (i), d##i)                       \
    GSF_PUT(sums + GSF__TILE_SUMS + 16 * (i), e##i) GSF_PUT(right + GSF__TILE_SUMS + 16 * (i), f##i)
    GSF__SIX(GSF_X)
#undef GSF_X
}
#undef GSF_PUT

// Two alternating sums per row, as a single one would be latency-bound. Pass a compile-time constant as `rows`.
GSF__INLINE_VNNI void gsf__int8_gemv_rows(const uint8_t* x, int64_t rows, const int8_t* w, int64_t count, int32_t* sums) {
    __m512i even0 = _mm512_setzero_si512(), even1 = even0, even2 = even0, even3 = even0;
    __m512i odd0 = even0, odd1 = even0, odd2 = even0, odd3 = even0, v;
#define GSF_ROWS(X) X(0) X(1) X(2) X(3)
#define GSF_EVEN(r) if (rows > r) even##r = _mm512_dpbusd_epi32(even##r, gsf__int8_four(x + 4 * (r)), v);
#define GSF_ODD(r) if (rows > r) odd##r = _mm512_dpbusd_epi32(odd##r, gsf__int8_four(x + 4 * (rows + (r))), v);
    for (; count >= 8; count -= 8, x += 8 * rows, w += 8 * GSF__TILE_COLUMNS) {
        if (rows > 1) { // for one row the hardware prefetches early enough
            _mm_prefetch((const char*)w + 2 * GSF__INT8_AHEAD, _MM_HINT_T0);
            _mm_prefetch((const char*)w + 2 * GSF__INT8_AHEAD + 64, _MM_HINT_T0);
        }
        v = _mm512_loadu_si512(w);
        GSF_ROWS(GSF_EVEN)
        v = _mm512_loadu_si512(w + 4 * GSF__TILE_COLUMNS);
        GSF_ROWS(GSF_ODD)
    }
    if (count > 0) {
        v = _mm512_loadu_si512(w);
        GSF_ROWS(GSF_EVEN)
    }
#define GSF_PUT(r) if (rows > r) _mm512_storeu_si512(sums + (r) * GSF__TILE_COLUMNS, _mm512_add_epi32(even##r, odd##r));
    GSF_ROWS(GSF_PUT)
#undef GSF_PUT
#undef GSF_ODD
#undef GSF_EVEN
#undef GSF_ROWS
}

GSF__TARGET_VNNI static void gsf__int8_gemv_vnni(const void* a, int64_t rows, const int8_t* w, int64_t count,
                                                 int32_t* sums) {
    const uint8_t* x = (const uint8_t*)a;
    if (rows == 1) gsf__int8_gemv_rows(x, 1, w, count, sums);
    else if (rows == 2) gsf__int8_gemv_rows(x, 2, w, count, sums);
    else if (rows == 3) gsf__int8_gemv_rows(x, 3, w, count, sums);
    else gsf__int8_gemv_rows(x, 4, w, count, sums);
}

GSF__TARGET_AVX512 static void gsf__int8_scale_vnni(const int32_t* sums, const int32_t* offsets, const float* rows,
                                                    const float* columns, float* out) {
    const __m512i offset = _mm512_loadu_si512(offsets);
    const __m512 scale = _mm512_loadu_ps(columns);
    for (int i = 0; i < GSF__TILE_ROWS; i++) {
        const __m512i v = _mm512_sub_epi32(_mm512_loadu_si512(sums + i * GSF__TILE_COLUMNS), offset);
        _mm512_storeu_ps(out + i * GSF__TILE_COLUMNS, _mm512_cvtepi32_ps(v) * _mm512_set1_ps(rows[i]) * scale);
    }
}

static const gsf__int8_kernels gsf__int8_vnni = {
    gsf__int8_rotate_avx512, gsf__int8_quantize_avx2, gsf__int8_quantize_x_vnni, sizeof(uint8_t), NULL,
    gsf__int8_tile_vnni, gsf__int8_four_tiles_vnni, gsf__int8_gemv_vnni, GSF__GEMV_ROWS, gsf__int8_scale_vnni};

#endif

static const gsf__int8_kernels* gsf__int8_kernels_of(gsf_cpu_level level) {
#if GSF__X86
    if (level >= GSF_CPU_AVX512_VNNI) return &gsf__int8_vnni;
    if (level >= GSF_CPU_AVX2) return &gsf__int8_avx2;
#endif
    (void)level;
    return &gsf__int8_scalar;
}

// ---- int8: blocks and scheduling

// Rotates and rounds a row (`in` values, modified in place, with room up to `padded`) to fours that are `pitch` apart;
// as int16 if it is a weight. Returns the scale: NaN, with zeros, for a row with a NaN or infinity; 0 for a row whose
// largest magnitude is below 1e-30, as 127 divided by it would overflow float.
static float gsf__int8_row(const gsf__int8_kernels* kernels, int weight, float* x, int64_t in, int64_t padded, int64_t block,
                           void* out, int64_t pitch) {
    const float top = kernels->rotate(x, in, block);
    const int there = top >= 1e-30f && top <= FLT_MAX;
    for (int64_t k = in; k < padded; k++) x[k] = 0.0f;
    if (!there) memset(x, 0, (size_t)padded * sizeof *x);
    (weight ? kernels->quantize : kernels->quantize_x)(x, padded, there ? 127.0f / top : 1.0f, out, pitch);
    return there ? top / 127.0f : top <= FLT_MAX ? 0.0f : NAN;
}

typedef struct gsf__quantize_job {
    const gsf__int8_kernels* kernels;
    const gsf_nn_tensor* tensor;
    gsf__nn_quantized* weight;
    int64_t padded;
    float* workers; // (padded) floats, then as many 16-bit integers
    size_t per_worker;
} gsf__quantize_job;

static void gsf__quantize_panel(void* arg, size_t panel, int32_t worker) {
    const gsf__quantize_job* job = (const gsf__quantize_job*)arg;
    const gsf__nn_quantized* w = job->weight;
    float* x = job->workers + (size_t)worker * job->per_worker;
    int16_t* q = (int16_t*)(void*)(x + job->padded);
    int8_t* to = w->data + panel * (size_t)job->padded * GSF__TILE_COLUMNS;
    for (int64_t c = 0; c < GSF__TILE_COLUMNS; c++) {
        const int64_t row = (int64_t)panel * GSF__TILE_COLUMNS + c;
        float scale = 0.0f;
        int32_t sum = 0;
        if (row < w->out) {
            gsf_nn_convert_tensor(job->tensor, row * w->in, w->in, x);
            scale = gsf__int8_row(job->kernels, 1, x, w->in, job->padded, w->block, q, 4) / (float)w->block;
        } else {
            memset(q, 0, (size_t)job->padded * sizeof *q);
        }
        w->scales[row] = scale;
        for (int64_t k = 0; k < job->padded; k++) {
            to[(k >> 2) * 64 + c * 4 + (k & 3)] = (int8_t)q[k];
            sum += q[k];
        }
        w->offsets[row] = 128 * sum;
    }
}

static gsf_result gsf__check_quantize(gsf_context* ctx, const gsf_nn_tensor* w) {
    if (!w || !w->data) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "int8: the weight is missing");
    const char* name = w->name ? w->name : "weight";
    if (w->rank < 2 || w->shape[0] < 1 || w->count / w->shape[0] < 1 || w->count % w->shape[0])
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "int8: %s is not a matrix", name);
    if (w->dtype != GSF_NN_F32 && w->dtype != GSF_NN_BF16 && w->dtype != GSF_NN_F16)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "int8: %s is %s", name, gsf__nn_dtype_name(w->dtype));
    if (w->count / w->shape[0] > GSF__INT8_LONGEST)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "int8: %s has %lld inputs, at most %d fit 32-bit sums", name,
                        (long long)(w->count / w->shape[0]), GSF__INT8_LONGEST);
    return GSF_OK;
}

static void gsf__nn_destroy_quantized(gsf_context* ctx, gsf__nn_quantized* weight) {
    gsf_free(ctx, weight->data);
    memset(weight, 0, sizeof *weight);
}

// Quantises (out, in) weights in f32, bf16 or f16 to symmetric 8-bit integers with one scale per output. First a
// Hadamard rotation of blocks of inputs (the largest power of two up to 256 that divides `in`) spreads outliers;
// `no_rotation` leaves it out. A NaN or infinity gives GSF_ERROR_NUMERIC and the tensor's name.
static gsf_result gsf__nn_quantize_weight(gsf_context* ctx, const gsf_nn_tensor* weight, int32_t no_rotation,
                                          gsf__nn_quantized* out) {
    gsf__quantize_job job;
    gsf__nn_quantized made;
    memset(out, 0, sizeof *out);
    memset(&job, 0, sizeof job);
    memset(&made, 0, sizeof made);
    GSF__TRY(gsf__check_quantize(ctx, weight));
    made.out = weight->shape[0];
    made.in = weight->count / made.out;
    made.block = 1;
    while (!no_rotation && made.block < GSF__INT8_BLOCK && made.in % (2 * made.block) == 0) made.block *= 2;
    job.padded = gsf__round_up(made.in, 4);
    job.per_worker = (size_t)gsf__round_up(job.padded + job.padded / 2, 16);
    size_t values, scratch;
    const size_t columns = ((size_t)made.out + GSF__TILE_COLUMNS - 1) / GSF__TILE_COLUMNS * GSF__TILE_COLUMNS;
    if (!gsf__mul_size(columns, (size_t)job.padded, &values) || columns > (SIZE_MAX - values) / 8 ||
        !gsf__mul_size(job.per_worker, (size_t)ctx->parallel.worker_count, &scratch))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "int8: %lld x %lld", (long long)made.out, (long long)made.in);
    made.bytes = values + columns * (sizeof(float) + sizeof(int32_t));
    made.data = (int8_t*)gsf_alloc(ctx, made.bytes, 1); // scales and offsets follow; `values` is a multiple of 64
    if (!made.data) return GSF_ERROR_OUT_OF_MEMORY;
    made.scales = (float*)(void*)(made.data + values);
    made.offsets = (int32_t*)(void*)(made.scales + columns);
    job.workers = (float*)gsf_alloc(ctx, scratch, sizeof(float));
    if (!job.workers) {
        gsf__nn_destroy_quantized(ctx, &made);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    job.kernels = gsf__int8_kernels_of(ctx->cpu_level);
    job.tensor = weight;
    job.weight = &made;
    gsf__parallel_for(ctx, columns / GSF__TILE_COLUMNS, gsf__quantize_panel, &job);
    gsf_free(ctx, job.workers);
    for (int64_t n = 0; n < made.out; n++)
        if (!(made.scales[n] <= FLT_MAX)) {
            gsf__nn_destroy_quantized(ctx, &made);
            return gsf_fail(ctx, GSF_ERROR_NUMERIC, "int8: %s has a NaN or infinity in row %lld",
                            weight->name ? weight->name : "weight", (long long)n);
        }
    *out = made;
    return GSF_OK;
}

static void gsf__int8_quantize_rows(void* arg, size_t group, int32_t worker) { // six rows of x
    const gsf__int8_job* job = (const gsf__int8_job*)arg;
    const gsf__nn_linear_desc* d = &job->linear.desc;
    const int64_t at = (int64_t)group * GSF__TILE_ROWS, in = job->weight->in;
    float* x = (float*)(void*)(job->workers + (size_t)worker * job->per_worker);
    const size_t size = job->kernels->x_size;
    char* out = job->x + (size_t)(at * job->padded) * size;
    for (int64_t r = 0; r < GSF__TILE_ROWS; r++) {
        if (at + r < job->rows) memcpy(x, d->x + (job->first + at + r) * d->ldx, (size_t)in * sizeof *x);
        else memset(x, 0, (size_t)in * sizeof *x);
        job->scales[at + r] = gsf__int8_row(job->kernels, 0, x, in, job->padded, job->weight->block,
                                            out + 4 * (size_t)r * size, 4 * GSF__TILE_ROWS);
    }
}

static void gsf__int8_fetch(const int8_t* p, int64_t count) { // otherwise widening stalls on distant panels
#if defined(__GNUC__) || defined(__clang__)
    for (int64_t i = 0; i < count; i += 64) __builtin_prefetch(p + i, 0, 2);
#endif
    (void)p;
    (void)count;
}

// Scales the sums of a tile and writes them to y through the epilogue.
static void gsf__int8_epilogue(const gsf__int8_job* job, const int32_t* sums, int64_t row, int64_t rows, int64_t column,
                               int64_t columns, float* tile) {
    const gsf__nn_quantized* w = job->weight;
    job->kernels->scale(sums, w->offsets + column, job->scales + row, w->scales + column, tile);
    job->linear.kernels->epilogue(&job->linear, tile, GSF__TILE_COLUMNS, job->first + row, rows, column, columns);
}

// All tiles of one or two panels at one step, like gsf__linear_panels.
static void gsf__int8_panels(const gsf__int8_job* job, int64_t row, int64_t rows, int64_t column, int64_t columns, int64_t k,
                             int64_t count, int32_t* sums, int64_t next, int16_t* panel, float* tile) {
    const gsf__int8_kernels* kernels = job->kernels;
    const int64_t panels = gsf__ceil_div(columns, GSF__TILE_COLUMNS), groups = gsf__ceil_div(rows, GSF__TILE_ROWS);
    const int64_t panel_size = job->padded * GSF__TILE_COLUMNS, group_size = job->padded * GSF__TILE_ROWS;
    const int8_t* w = job->weight->data + column * job->padded + k * GSF__TILE_COLUMNS;
    const int64_t share = count * GSF__TILE_COLUMNS / groups; // of a panel needed next, prefetched with each tile
    const int8_t* ahead = column + 2 * columns <= job->weight->out ? w + panels * panel_size : w;
    for (int64_t g = 0, step; g < groups; g += step) {
        const int64_t r = row + g * GSF__TILE_ROWS;
        const char* x = job->x + (size_t)(r * job->padded + k * GSF__TILE_ROWS) * kernels->x_size;
        int32_t* s = sums + g * GSF__TILE_SUMS;
        step = kernels->four_tiles && panels == 2 && g + 2 <= groups ? 2 : 1;
        // each half of the groups prefetches one of the two panels
        const int8_t* wanted = g < groups / 2 ? ahead + 2 * g * share : ahead + panel_size + (2 * g - groups) * share;
        if (step == 2)
            kernels->four_tiles(x, group_size * (int64_t)kernels->x_size, w, panel_size, count, k > 0, s, next, wanted,
                                4 * share);
        for (int64_t p = 0; step == 1 && p < panels; p++) {
            const void* b = kernels->widen ? (const void*)(panel + p * count * GSF__TILE_COLUMNS) : w + p * panel_size;
            if (kernels->widen) gsf__int8_fetch(ahead + p * panel_size + g * share, share);
            kernels->tile(x, b, count, k > 0, s + p * next);
        }
        if (k + count < job->padded) continue;
        for (int64_t t = 0; t < step * panels; t++) {
            const int64_t p = t / step, down = t % step * GSF__TILE_ROWS, c = p * GSF__TILE_COLUMNS;
            gsf__int8_epilogue(job, s + p * next + t % step * GSF__TILE_SUMS, r + down,
                               gsf__least(row + rows - r - down, GSF__TILE_ROWS), column + c,
                               gsf__least(columns - c, GSF__TILE_COLUMNS), tile);
        }
    }
}

static void gsf__int8_block(void* arg, size_t index, int32_t worker) { // a block of rows and outputs
    const gsf__int8_job* job = (const gsf__int8_job*)arg;
    const int64_t row = (int64_t)index % job->row_blocks * job->block_rows; // among the current rows
    const int64_t column = (int64_t)index / job->row_blocks * job->block_columns;
    const int64_t rows = gsf__least(job->rows - row, job->block_rows);
    const int64_t columns = gsf__least(job->weight->out - column, job->block_columns);
    const int64_t next = gsf__ceil_div(rows, GSF__TILE_ROWS) * GSF__TILE_SUMS; // between panels
    int32_t* sums = (int32_t*)(void*)(job->workers + (size_t)worker * job->per_worker);
    float* tile = (float*)(void*)(sums + job->block_rows * job->block_columns);
    int16_t* panel = (int16_t*)(void*)(tile + GSF__TILE_SUMS);
    for (int64_t k = 0; k < job->padded; k += job->depth) {
        const int64_t count = gsf__least(job->padded - k, job->depth);
        for (int64_t c = 0; c < columns; c += GSF__LINEAR_PAIR) {
            const int64_t width = gsf__least(columns - c, GSF__LINEAR_PAIR);
            for (int64_t p = 0; job->kernels->widen && p < width; p += GSF__TILE_COLUMNS)
                job->kernels->widen(job->weight->data + (column + c + p) * job->padded + k * GSF__TILE_COLUMNS, count,
                                    panel + p * count);
            gsf__int8_panels(job, row, rows, column + c, width, k, count, sums + c / GSF__TILE_COLUMNS * next, next, panel,
                             tile);
        }
    }
}

static void gsf__int8_gemv(void* arg, size_t index, int32_t worker) { // some panels of outputs, all rows
    const gsf__int8_job* job = (const gsf__int8_job*)arg;
    const int64_t rows = job->rows, most = job->kernels->gemv_rows, first = (int64_t)index * job->block_columns;
    const int64_t end = gsf__least(first + job->block_columns, job->weight->out);
    int32_t* sums = (int32_t*)(void*)(job->workers + (size_t)worker * job->per_worker);
    float* tile = (float*)(void*)(sums + GSF__TILE_SUMS);
    memset(sums, 0, GSF__TILE_SUMS * sizeof *sums); // also of missing rows
    for (int64_t column = first; column < end; column += GSF__TILE_COLUMNS) {
        for (int64_t r = 0; r < rows; r += most)
            job->kernels->gemv(job->x + (size_t)(r * job->padded) * job->kernels->x_size, gsf__least(rows - r, most),
                               job->weight->data + column * job->padded, job->padded, sums + r * GSF__TILE_COLUMNS);
        gsf__int8_epilogue(job, sums, 0, rows, column, gsf__least(end - column, GSF__TILE_COLUMNS), tile);
    }
}

static void gsf__int8_run_gemv(gsf_context* ctx, gsf__int8_job* job) {
    const gsf__nn_linear_desc* d = &job->linear.desc;
    float* x = (float*)(void*)job->workers;
    job->rows = d->rows;
    memset(job->scales, 0, GSF__TILE_ROWS * sizeof *job->scales);
    for (int64_t r = 0; r < d->rows; r++) {
        const int64_t first = r - r % job->kernels->gemv_rows, width = gsf__least(d->rows - first, job->kernels->gemv_rows);
        memcpy(x, d->x + r * d->ldx, (size_t)job->weight->in * sizeof *x);
        job->scales[r] = gsf__int8_row(job->kernels, 0, x, job->weight->in, job->padded, job->weight->block,
                                       job->x + (size_t)(first * job->padded + 4 * (r - first)) * job->kernels->x_size,
                                       4 * width);
    }
    gsf__parallel_for(ctx, (size_t)gsf__ceil_div(job->weight->out, job->block_columns), gsf__int8_gemv, job);
}

// Divides the work, by its sizes; returns the bytes of scratch for `workers` workers, or 0 on overflow.
static size_t gsf__int8_plan(gsf__int8_job* job, int64_t rows, size_t workers) {
    const int64_t out = job->weight->out;
    size_t x, bytes;
    if (rows > INT64_MAX / 256 || out > INT64_MAX / 256) return 0;
    job->depth = gsf__even_piece(job->padded, job->kernels->widen ? GSF__INT8_DEPTH : 2 * GSF__INT8_DEPTH, 4);
    const int64_t most = gsf__round_up(GSF__INT8_HELD / job->padded + 1, GSF__INT8_ROWS);
    job->held = gsf__even_piece(rows, most, GSF__TILE_ROWS);
    job->block_rows = gsf__even_piece(job->held, GSF__INT8_ROWS, 2 * GSF__TILE_ROWS);
    job->block_columns = gsf__even_piece(out, GSF__INT8_COLUMNS, GSF__LINEAR_PAIR);
    if (rows <= GSF__GEMV_ROWS) { // all rows at once; outputs in GSF__GEMV_CHUNKS parts
        const int64_t least = GSF__GEMV_BYTES / job->padded + 1, share = gsf__ceil_div(out, GSF__GEMV_CHUNKS);
        job->block_columns = gsf__round_up(gsf__least(share < least ? least : share, out), GSF__TILE_COLUMNS);
    }
    const int64_t block = 4 * (job->block_rows * job->block_columns + GSF__TILE_SUMS) + 2 * job->depth * GSF__LINEAR_PAIR;
    const int64_t row = 4 * job->padded; // the two phases share the memory
    job->per_worker = (size_t)gsf__round_up(block > row ? block : row, 64);
    if (!gsf__mul_size(job->per_worker, workers, &bytes)) return 0;
    if (!gsf__mul_size((size_t)job->held, 2 * (size_t)job->padded + sizeof(float), &x)) return 0;
    x += 64 + ((size_t)out + 16) * sizeof(float);
    return bytes > SIZE_MAX - x ? 0 : bytes + x;
}

static gsf_result gsf__check_int8(gsf_context* ctx, const gsf__nn_linear_desc* desc, const gsf__nn_quantized* w) {
    if (!desc->x || !desc->y || !w || !w->data || desc->rows < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "int8: x, y or weight is missing");
    if (desc->bias && (desc->bias->count != w->out || !desc->bias->data))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "int8: %s has %lld values, not %lld",
                        desc->bias->name ? desc->bias->name : "bias", (long long)desc->bias->count, (long long)w->out);
    if ((desc->ldx && desc->ldx < w->in) || (desc->ldy && desc->ldy < w->out))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "int8: rows of %lld and %lld values, but the weight is %lld x %lld", (long long)desc->ldx,
                        (long long)desc->ldy, (long long)w->out, (long long)w->in);
    return GSF_OK;
}

// gsf__nn_run_linear with such a weight; desc->weight is ignored. Each row of x is rotated and rounded to 8 bits with
// its own scale; sums are exact. Relative L2 error for Gaussian values: 1.2e-2. A row with a NaN or infinity gives
// NaNs.
static gsf_result gsf__nn_run_linear_int8(gsf_context* ctx, gsf__nn_workspace* workspace,
                                          const gsf__nn_linear_desc* desc, const gsf__nn_quantized* weight) {
    gsf__nn_workspace own;
    gsf__int8_job job;
    memset(&own, 0, sizeof own);
    memset(&job, 0, sizeof job);
    GSF__TRY(gsf__check_int8(ctx, desc, weight));
    if (desc->rows == 0) return GSF_OK;
    gsf__linear_job* linear = &job.linear;
    linear->desc = *desc;
    if (!linear->desc.ldx) linear->desc.ldx = weight->in;
    if (!linear->desc.ldy) linear->desc.ldy = weight->out;
    job.weight = weight;
    job.kernels = gsf__int8_kernels_of(ctx->cpu_level);
    job.padded = gsf__round_up(weight->in, 4);
    const size_t bytes = gsf__int8_plan(&job, desc->rows, (size_t)ctx->parallel.worker_count);
    if (!bytes)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "int8: %lld rows x %lld x %lld", (long long)desc->rows,
                        (long long)weight->in, (long long)weight->out);
    job.workers = (char*)gsf__nn_scratch(ctx, workspace ? workspace : &own, bytes);
    if (!job.workers) return GSF_ERROR_OUT_OF_MEMORY;
    job.x = job.workers + job.per_worker * (size_t)ctx->parallel.worker_count;
    job.scales = (float*)(void*)(job.x + (size_t)(job.held * job.padded) * sizeof(int16_t));
    linear->bias = job.scales + job.held;
    memset(linear->bias, 0, (size_t)(weight->out + 16) * sizeof(float));
    if (desc->bias) gsf_nn_convert_tensor(desc->bias, 0, weight->out, linear->bias);
    linear->kernels = gsf__linear_kernels_of(ctx->cpu_level, 0);
    const int64_t column_blocks = gsf__ceil_div(weight->out, job.block_columns);
    if (desc->rows <= GSF__GEMV_ROWS) gsf__int8_run_gemv(ctx, &job);
    for (; job.first < desc->rows && desc->rows > GSF__GEMV_ROWS; job.first += job.held) {
        job.rows = gsf__least(desc->rows - job.first, job.held);
        job.row_blocks = gsf__ceil_div(job.rows, job.block_rows);
        gsf__parallel_for(ctx, (size_t)gsf__ceil_div(job.rows, GSF__TILE_ROWS), gsf__int8_quantize_rows, &job);
        gsf__parallel_for(ctx, (size_t)(job.row_blocks * column_blocks), gsf__int8_block, &job);
    }
    gsf__nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn attention -------------------------------------------------------------

/* Online softmax over blocks of keys, as in FlashAttention. A unit of work is one head and a range of its queries. The
   queries are packed once. Then each block of keys is packed and, for every few groups of queries:
       logits   p = q k^T             (the packed queries include log2 e and the scale)
       weights  p = 2^(p - top)       top: the largest logit so far; earlier results are scaled by 2^(old top - top)
       values   out = out * that + p v
   Packed queries, sums and one block of keys stay in cache for any number of keys.
       q    [group][dim][8], 6 used    out  [group][panel][6][16]      panel: 16 columns of v, padded with zeros
       k    [panel of 16 keys][dim][16]    v    [panel][key][16]      p    [query][key]
   AVX-512 computes two groups by two panels at a time. In bf16 each float slot holds a pair of values: of q and k along
   dim, of v and the weights along the keys. This halves the number of slots. */
enum {
    GSF__ATT_GROUP = 6,       // queries per register tile: 6 x 16 sums, two vectors of keys, a broadcast: 15 registers
    GSF__ATT_PANEL = 16,
    GSF__ATT_KEYS = 256,      // keys per block
    GSF__ATT_GROUPS = 8,      // groups of queries whose weights are in memory at a time
    GSF__ATT_TILE = GSF__ATT_GROUP * GSF__ATT_PANEL,
    GSF__ATT_QUERIES = GSF__ATT_GROUP * GSF__ATT_GROUPS,
    GSF__ATT_RANGE = 1536,    // queries per chunk, at most: more hide the packing better, but do not fit the cache
    GSF__ATT_LEAST_RANGE = 384,
    GSF__ATT_ROWS = 16,       // queries of the scalar kernel that are processed together for each key
    GSF__ATT_AHEAD = 16,      // prefetch distance in rows
    GSF__ATT_CHUNKS = 64,     // enough chunks to balance the load of the workers
};

typedef struct gsf__attention_job {
    gsf__nn_attention_desc desc;
    const struct gsf__attention_parts* parts; // NULL: the scalar kernel
    float* scratch;             // of all workers
    size_t scratch_floats;      // per worker
    int64_t ranges, range_size; // of the queries
    int64_t panels;             // of v, 16 columns each
} gsf__attention_job;

// Softmax is invariant to an offset shared by all keys, as it adds the same to each logit of a query, but a large
// offset costs precision. So a typical key is subtracted from all keys: per dimension the median of the means of three
// groups of five keys, which a single outlier cannot dominate, or 0 if it is not finite. `column`: the head's first.
static void gsf__attention_center(const gsf__nn_attention_desc* d, int64_t column, float* center) {
    const float* keys[15];
    for (int64_t n = 0; n < 15; n++) keys[n] = d->k + n * d->keys / 15 * d->ldk + column;
    for (int32_t i = 0; i < d->head_dim; i++) {
        float mean[3];
        for (int g = 0; g < 3; g++)
            mean[g] = (keys[g][i] + keys[g + 3][i] + keys[g + 6][i] + keys[g + 9][i] + keys[g + 12][i]) / 5.0f;
        const float low = mean[0] < mean[1] ? mean[0] : mean[1], high = mean[0] < mean[1] ? mean[1] : mean[0];
        const float middle = mean[2] < low ? low : mean[2] > high ? high : mean[2];
        center[i] = isfinite(middle) ? middle : 0.0f;
    }
}

// Logits of `queries` rows of a head, from row `first` on, to p (queries, keys). Four queries at a time share the
// centring of a key and have independent sums.
static void gsf__attention_logits_scalar(const gsf__nn_attention_desc* d, int64_t head, int64_t first, int64_t queries,
                                         const float* center, float* p) {
    const int64_t dim = d->head_dim, column = head * dim;
    for (int64_t j = 0; j < d->keys; j++) {
        const float *key = d->k + j * d->ldk + column, *q = d->q + first * d->ldq + column;
        float* to = p + j;
        int64_t r = 0;
        for (; r + 4 <= queries; r += 4, q += 4 * d->ldq, to += 4 * d->keys) {
            const float *q1 = q + d->ldq, *q2 = q1 + d->ldq, *q3 = q2 + d->ldq;
            float dot0 = 0.0f, dot1 = 0.0f, dot2 = 0.0f, dot3 = 0.0f;
            for (int64_t i = 0; i < dim; i++) {
                const float k = key[i] - center[i];
                dot0 += q[i] * k;
                dot1 += q1[i] * k;
                dot2 += q2[i] * k;
                dot3 += q3[i] * k;
            }
            to[0] = dot0 * d->scale;
            to[d->keys] = dot1 * d->scale;
            to[2 * d->keys] = dot2 * d->scale;
            to[3 * d->keys] = dot3 * d->scale;
        }
        for (; r < queries; r++, q += d->ldq, to += d->keys) {
            float dot = 0.0f;
            for (int64_t i = 0; i < dim; i++) dot += q[i] * (key[i] - center[i]);
            *to = dot * d->scale;
        }
    }
}

// The base-2 logarithm of the sum of 2^logit over the keys: logits in base 2, of centred keys.
static float gsf__attention_lse(float top, float total) { return (float)((double)top + log2((double)total)); }

// Attention of one query, given its logits p; sum: (head_dim), scratch.
static void gsf__attention_row(const gsf__nn_attention_desc* d, int64_t head, int64_t row, float* p, float* sum) {
    const int64_t dim = d->head_dim, column = head * dim;
    const int64_t at = (head * d->queries + row) * d->keys; // into mask and bias
    const unsigned char* mask = d->mask ? d->mask + at : NULL;
    float top = -FLT_MAX, total = 0.0f;
    for (int64_t j = 0; j < d->keys; j++) {
        if (d->bias) p[j] += d->bias[at + j];
        if ((!mask || mask[j]) && p[j] > top) top = p[j];
    }
    for (int64_t i = 0; i < dim; i++) sum[i] = 0.0f;
    for (int64_t j = 0; j < d->keys; j++) {
        if (mask && !mask[j]) continue;
        const float* v = d->v + j * d->ldv + column;
        const float weight = expf(p[j] - top);
        total += weight;
        for (int64_t i = 0; i < dim; i++) sum[i] += weight * v[i];
    }
    float* out = d->out + row * d->ldo + column;
    for (int64_t i = 0; i < dim; i++) out[i] = total == 0.0f ? 0.0f : sum[i] / total; // NaN propagates
    if (d->lse) d->lse[head * d->queries + row] = gsf__attention_lse(top * 1.44269504f, total);
}

static void gsf__attention_chunk_scalar(const gsf__attention_job* job, size_t chunk, int32_t worker) {
    const gsf__nn_attention_desc* d = &job->desc;
    const int64_t head = (int64_t)chunk / job->ranges, first = (int64_t)chunk % job->ranges * job->range_size;
    const int64_t dim = d->head_dim, end = gsf__least(first + job->range_size, d->queries);
    float* p = job->scratch + (size_t)worker * job->scratch_floats;
    float *sum = p + GSF__ATT_ROWS * d->keys, *center = sum + dim;
    gsf__attention_center(d, head * dim, center);
    for (int64_t row = first; row < end; row += GSF__ATT_ROWS) {
        const int64_t rows = gsf__least(end - row, GSF__ATT_ROWS);
        gsf__attention_logits_scalar(d, head, row, rows, center, p);
        for (int64_t r = 0; r < rows; r++) gsf__attention_row(d, head, row + r, p + r * d->keys, sum);
    }
}

typedef struct gsf__attention_scratch { // per worker
    float *q, *out, *k, *v, *p;
    float* top;    // [query] largest logit so far
    float* sum;    // [query][8] sum of the weights so far, by lane
    float* center; // [dim] subtracted from every key
} gsf__attention_scratch;

typedef struct gsf__attention_parts { // what differs between instruction sets; in bf16 each float slot holds a pair
    int64_t unit; // values per slot along head_dim: 1, or 2 in bf16
    // Packs (x - center) * factor of eight rows, `rows` of which exist, as to[slot * to_ld + row]; center may be NULL
    void (*pack_rows)(const float* from, int64_t rows, int64_t ld, const float* center, float factor, int64_t dim, float* to,
                      int64_t to_ld);
    void (*pack_values)(const gsf__attention_job* job, const float* from, int64_t keys, float* packed);
    // Computes the logits p of `groups` groups of queries and `panels` panels of keys
    void (*logits)(const float* q, int64_t groups, const float* k, int64_t panels, int64_t dim, float* p);
    // Turns the logits of `queries` rows into weights, raises `top`, updates `sum`, and sets `fade` to the factor for
    // earlier results. NaNs are ignored for `top`, but the weight of a NaN, and with it sum and output, is NaN.
    void (*weights)(float* p, int64_t queries, int64_t columns, float* top, float* sum, float fade[GSF__ATT_QUERIES]);
    // out = out * fade + p v
    void (*values)(const float* p, int64_t groups, const float* v, int64_t keys, int64_t panels, const float* fade,
                   float* out);
} gsf__attention_parts;

#if GSF__X86

static gsf__attention_scratch gsf__attention_scratch_of(const gsf__attention_job* job, int32_t worker) {
    const int64_t groups = (job->range_size + GSF__ATT_GROUP - 1) / GSF__ATT_GROUP, dim = job->desc.head_dim;
    gsf__attention_scratch s;
    s.p = job->scratch + (size_t)worker * job->scratch_floats;
    s.k = s.p + GSF__ATT_QUERIES * GSF__ATT_KEYS;
    s.v = s.k + GSF__ATT_KEYS * dim;
    s.out = s.v + GSF__ATT_KEYS * GSF__ATT_PANEL * job->panels;
    s.sum = s.out + groups * GSF__ATT_TILE * job->panels;
    s.q = s.sum + groups * GSF__ATT_GROUP * 8;
    s.top = s.q + groups * 8 * dim;
    s.center = s.top + groups * GSF__ATT_GROUP;
    return s;
}

// Prefetches a row of a head: rows are a few cache lines each and far apart, which defeats the hardware prefetcher.
static void gsf__attention_fetch(const float* from, int64_t row, int64_t rows, int64_t ld, int64_t dim) {
    for (int64_t i = 0; row < rows && i < dim; i += 16) gsf__nn_prefetch(from + row * ld + i);
}

GSF__TARGET_AVX2 static void gsf__attention_pack_rows(const float* from, int64_t rows, int64_t ld, const float* center,
                                                      float factor, int64_t dim, float* to, int64_t to_ld) {
    const __m256 f = _mm256_set1_ps(factor);
    for (int64_t i = 0; i < dim; i += 8) {
        const __m256i mask = gsf__nn_mask8(dim - i);
        const __m256 c = center ? _mm256_maskload_ps(center + i, mask) : _mm256_setzero_ps();
        if (rows >= 8 && dim - i >= 8) {
            gsf__nn_transpose8(from + i, ld, c, f, to + i * to_ld, to_ld);
            continue;
        }
        float whole[8][8], turned[8][8];
        for (int r = 0; r < 8; r++)
            _mm256_storeu_ps(whole[r], r < rows ? _mm256_maskload_ps(from + r * ld + i, mask) : _mm256_setzero_ps());
        gsf__nn_transpose8(whole[0], 8, c, f, turned[0], 8);
        for (int64_t u = 0; u < gsf__least(dim - i, 8); u++) memcpy(to + (i + u) * to_ld, turned[u], sizeof turned[u]);
    }
}

static void gsf__attention_pack_queries(const gsf__attention_job* job, const gsf__attention_parts* parts, const float* from,
                                        int64_t queries, float* packed) {
    const int64_t ld = job->desc.ldq, dim = job->desc.head_dim;
    const float factor = job->desc.scale * 1.44269504f; // base 2 instead of e
    for (int64_t first = 0; first < queries; first += GSF__ATT_GROUP, packed += 8 * dim / parts->unit) {
        for (int64_t r = first; r < first + GSF__ATT_GROUP; r++)
            gsf__attention_fetch(from, r + GSF__ATT_AHEAD, queries, ld, dim);
        parts->pack_rows(from + first * ld, queries - first, ld, NULL, factor, dim, packed, 8);
    }
}

// Packs the keys of `from`, minus `center`, into panels of 16, padding the last one.
static void gsf__attention_pack_keys(const gsf__attention_job* job, const gsf__attention_parts* parts, const float* from,
                                     const float* center, int64_t keys, float* packed) {
    const int64_t ld = job->desc.ldk, dim = job->desc.head_dim, panel = GSF__ATT_PANEL * dim / parts->unit;
    for (int64_t j = 0; j < gsf__round_up(keys, GSF__ATT_PANEL); j += 8) {
        for (int64_t r = j; r < j + 8; r++) gsf__attention_fetch(from, r + GSF__ATT_AHEAD, keys, ld, dim);
        parts->pack_rows(from + j * ld, keys - j, ld, center, 1.0f, dim,
                         packed + j / GSF__ATT_PANEL * panel + j % GSF__ATT_PANEL, GSF__ATT_PANEL);
    }
}

GSF__TARGET_AVX2 static void gsf__attention_pack_values(const gsf__attention_job* job, const float* from, int64_t keys,
                                                        float* packed) {
    const int64_t ld = job->desc.ldv, dim = job->desc.head_dim;
    for (int64_t j = 0; j < keys; j++) {
        const float* row = from + j * ld;
        gsf__attention_fetch(from, j + GSF__ATT_AHEAD, keys, ld, dim);
        for (int64_t i = 0; i < job->panels * GSF__ATT_PANEL; i += 8) {
            float* to = packed + (i / GSF__ATT_PANEL * GSF__ATT_KEYS + j) * GSF__ATT_PANEL + i % GSF__ATT_PANEL;
            const __m256i mask = gsf__nn_mask8(dim - i);
            _mm256_storeu_ps(to, i + 8 <= dim ? _mm256_loadu_ps(row + i) : _mm256_maskload_ps(row + i, mask));
        }
    }
}

GSF__TARGET_AVX2 static void gsf__attention_logits_avx2(const float* q, int64_t groups, const float* k, int64_t panels,
                                                        int64_t dim, float* p) {
    for (int64_t panel = 0; panel < panels; panel++, k += GSF__ATT_PANEL * dim)
        for (int64_t g = 0; g < groups; g++) {
            __m256 c[12];
            float* to = p + g * GSF__ATT_GROUP * GSF__ATT_KEYS + panel * GSF__ATT_PANEL;
            gsf__nn_tile(q + g * 8 * dim, 1, 8, k, dim, c);
            for (int r = 0; r < GSF__ATT_GROUP; r++) {
                _mm256_storeu_ps(to + r * GSF__ATT_KEYS, c[2 * r]);
                _mm256_storeu_ps(to + r * GSF__ATT_KEYS + 8, c[2 * r + 1]);
            }
        }
}

// Computes pairs of panels by pairs of groups; `rest`, a function for any number of both, handles the odd ones.
#define GSF__ATT_LOGITS(multiply, rest)                                                                                 \
    const int64_t even = groups & ~(int64_t)1, height = GSF__ATT_GROUP * GSF__ATT_KEYS;                                 \
    for (int64_t panel = 0; panel + 2 <= panels; panel += 2, k += 2 * GSF__ATT_PANEL * dim) {                           \
        float* to = p + panel * GSF__ATT_PANEL;                                                                         \
        for (int64_t g = 0; g < even; g += 2, to += 2 * height) {                                                       \
            const float *a = q + g * 8 * dim, *b = k;                                                                   \
            GSF__SIX(GSF__FOUR_ZEROS)                                                                             \
            GSF__FOUR_TILES(multiply, , a, 1, 8, 8 * dim, b, GSF__ATT_PANEL * dim, dim)                               \
            GSF__SIX(GSF__ATT_STORE)                                                                              \
        }                                                                                                               \
        if (even < groups) rest(q + even * 8 * dim, 1, k, 2, dim, to);                                                  \
    }                                                                                                                   \
    if (panels % 2) rest(q, groups, k, 1, dim, p + (panels - 1) * GSF__ATT_PANEL);
#define GSF__ATT_STORE(r)                                                                                               \
    _mm512_storeu_ps(to + r * GSF__ATT_KEYS, c##r);                                                                     \
    _mm512_storeu_ps(to + r * GSF__ATT_KEYS + GSF__ATT_PANEL, d##r);                                                    \
    _mm512_storeu_ps(to + height + r * GSF__ATT_KEYS, e##r);                                                            \
    _mm512_storeu_ps(to + height + r * GSF__ATT_KEYS + GSF__ATT_PANEL, f##r);

GSF__TARGET_AVX512 static void gsf__attention_logits_avx512(const float* q, int64_t groups, const float* k, int64_t panels,
                                                            int64_t dim, float* p) {
    GSF__ATT_LOGITS(gsf__nn_add_product, gsf__attention_logits_avx2)
}

// Adds the bias, times log2 e, to the logits of `queries` rows and `keys` columns.
GSF__TARGET_AVX2 static void gsf__attention_bias(const float* bias, int64_t bias_stride, int64_t queries, int64_t keys,
                                                 float* p) {
    const __m256 factor = _mm256_set1_ps(1.44269504f);
    for (int64_t r = 0; r < gsf__least(queries, GSF__ATT_QUERIES); r++, p += GSF__ATT_KEYS, bias += bias_stride)
        for (int64_t j = 0; j < keys; j += 8) {
            const __m256i mask = gsf__nn_mask8(keys - j);
            const __m256 b = j + 8 <= keys ? _mm256_loadu_ps(bias + j) : _mm256_maskload_ps(bias + j, mask);
            _mm256_storeu_ps(p + j, _mm256_fmadd_ps(b, factor, _mm256_loadu_ps(p + j)));
        }
}

// Sets the logits of masked keys, and of the padding columns `keys` to `columns`, to -inf.
static void gsf__attention_hide(const unsigned char* mask, int64_t mask_stride, int64_t queries, int64_t keys,
                                int64_t columns, float* p) {
    for (int64_t r = 0; r < GSF__ATT_QUERIES; r++, p += GSF__ATT_KEYS) {
        for (int64_t j = 0; mask && r < queries && j < keys; j++)
            if (!mask[r * mask_stride + j]) p[j] = -INFINITY;
        for (int64_t j = keys; j < columns; j++) p[j] = -INFINITY;
    }
}

GSF__TARGET_AVX2 static void gsf__attention_weights_avx2(float* p, int64_t queries, int64_t columns, float* top, float* sum,
                                                         float fade[GSF__ATT_QUERIES]) {
    const gsf__v_exp2_terms_avx2 c = gsf__v_exp2_of_avx2(1);
    for (int64_t r = 0; r < queries; r++) {
        const float* row = p + r * GSF__ATT_KEYS;
        __m256 top0 = _mm256_set1_ps(top[r]), top1 = top0;
        for (int64_t j = 0; j < columns; j += 16) { // max returns its second operand if the first is NaN
            top0 = _mm256_max_ps(_mm256_loadu_ps(row + j), top0);
            top1 = _mm256_max_ps(_mm256_loadu_ps(row + j + 8), top1);
        }
        const float raised = gsf__v_largest_avx2(_mm256_max_ps(top0, top1));
        fade[r] = top[r] - raised;
        top[r] = raised;
    }
    for (int64_t r = 0; r < queries; r += 8) {
        const __m256i mask = gsf__nn_mask8(queries - r);
        _mm256_maskstore_ps(fade + r, mask, gsf__v_exp2_low_avx2(&c, _mm256_maskload_ps(fade + r, mask)));
    }
    for (int64_t r = 0; r < queries; r++) {
        float* row = p + r * GSF__ATT_KEYS;
        const __m256 t = _mm256_set1_ps(top[r]);
        __m256 total = _mm256_set1_ps(fade[r]) * _mm256_loadu_ps(sum + 8 * r);
        for (int64_t j = 0; j < columns; j += 8) {
            const __m256 weight = gsf__v_exp2_low_avx2(&c, _mm256_loadu_ps(row + j) - t);
            _mm256_storeu_ps(row + j, weight);
            total = total + weight;
        }
        _mm256_storeu_ps(sum + 8 * r, total);
    }
}

// Raises `top` to the largest logit of each row; fade = 2^(old top - top).
GSF__INLINE_AVX512 void gsf__attention_tops_avx512(const float* p, int64_t queries, int64_t columns, float* top,
                                                   float fade[GSF__ATT_QUERIES]) {
    const gsf__v_exp2_terms_avx512 terms = gsf__v_exp2_of_avx512(0);
    for (int64_t r = 0; r < queries; r++) {
        __m512 highest = _mm512_set1_ps(top[r]);
        for (int64_t j = 0; j < columns; j += 16)
            highest = _mm512_max_ps(_mm512_loadu_ps(p + r * GSF__ATT_KEYS + j), highest);
        const float raised = gsf__v_largest_avx512(highest);
        fade[r] = top[r] - raised;
        top[r] = raised;
    }
    for (int64_t r = 0; r < queries; r += 16) {
        const __mmask16 mask = gsf__nn_mask16(queries - r);
        gsf__nn_store16(fade + r, mask, gsf__v_exp2_low_avx512(&terms, _mm512_maskz_loadu_ps(mask, fade + r)));
    }
}

GSF__INLINE_AVX512 void gsf__attention_add_total(__m512 total, float fade, float sum[8]) {
    _mm256_storeu_ps(sum, _mm256_set1_ps(fade) * _mm256_loadu_ps(sum) + gsf__nn_fold16(total));
}

GSF__TARGET_AVX512 static void gsf__attention_weights_avx512(float* p, int64_t queries, int64_t columns, float* top,
                                                             float* sum, float fade[GSF__ATT_QUERIES]) {
    const gsf__v_exp2_terms_avx512 terms = gsf__v_exp2_of_avx512(1);
    gsf__attention_tops_avx512(p, queries, columns, top, fade);
    for (int64_t r = 0; r < queries; r++) {
        float* row = p + r * GSF__ATT_KEYS;
        const __m512 t = _mm512_set1_ps(top[r]);
        __m512 total = _mm512_setzero_ps();
        for (int64_t j = 0; j < columns; j += 16) {
            const __m512 weight = gsf__v_exp2_low_avx512(&terms, _mm512_loadu_ps(row + j) - t);
            _mm512_storeu_ps(row + j, weight);
            total = total + weight;
        }
        gsf__attention_add_total(total, fade[r], sum + 8 * r);
    }
}

GSF__TARGET_AVX2 static void gsf__attention_values_avx2(const float* p, int64_t groups, const float* v, int64_t keys,
                                                        int64_t panels, const float* fade, float* out) {
    for (int64_t panel = 0; panel < panels; panel++, v += GSF__ATT_KEYS * GSF__ATT_PANEL)
        for (int64_t g = 0; g < groups; g++) {
            __m256 c[12];
            float* to = out + (g * panels + panel) * GSF__ATT_TILE;
            for (int i = 0; i < GSF__ATT_TILE; i += 16) _mm_prefetch((const char*)(to + i), _MM_HINT_T0);
            gsf__nn_tile(p + g * GSF__ATT_GROUP * GSF__ATT_KEYS, GSF__ATT_KEYS, 1, v, keys, c);
            for (int r = 0; r < GSF__ATT_GROUP; r++, to += GSF__ATT_PANEL) {
                const __m256 f = _mm256_broadcast_ss(fade + g * GSF__ATT_GROUP + r);
                _mm256_storeu_ps(to, _mm256_fmadd_ps(f, _mm256_loadu_ps(to), c[2 * r]));
                _mm256_storeu_ps(to + 8, _mm256_fmadd_ps(f, _mm256_loadu_ps(to + 8), c[2 * r + 1]));
            }
        }
}

// Computes pairs of panels by pairs of groups; `rest` handles the odd ones. `places`: slots per row of p.
#define GSF__ATT_VALUES(multiply, rest, places)                                                                         \
    const int64_t height = GSF__ATT_GROUP * GSF__ATT_KEYS, width = panels * GSF__ATT_TILE;                              \
    const int64_t even = panels % 2 ? 0 : groups & ~(int64_t)1; /* odd numbers occur in no model */                     \
    for (int64_t panel = 0; panel < panels; panel += 2)                                                                 \
        for (int64_t g = 0; g < even; g += 2) {                                                                         \
            const float *a = p + g * height, *b = v + panel * GSF__ATT_KEYS * GSF__ATT_PANEL;                           \
            const float* fades = fade + g * GSF__ATT_GROUP;                                                             \
            float* to = out + (g * panels + panel) * GSF__ATT_TILE;                                                     \
            for (int i = 0; i < 2 * GSF__ATT_TILE; i += 16) {                                                           \
                _mm_prefetch((const char*)(to + i), _MM_HINT_T0);                                                       \
                _mm_prefetch((const char*)(to + width + i), _MM_HINT_T0);                                               \
            }                                                                                                           \
            GSF__SIX(GSF__FOUR_ZEROS)                                                                             \
            GSF__FOUR_TILES(multiply, , a, GSF__ATT_KEYS, 1, height, b, GSF__ATT_KEYS * GSF__ATT_PANEL, places)       \
            GSF__SIX(GSF__ATT_FADE)                                                                               \
        }                                                                                                               \
    if (even < groups)                                                                                                  \
        rest(p + even * height, groups - even, v, keys, panels, fade + even * GSF__ATT_GROUP, out + even * width);
#define GSF__ATT_FADE(r)                                                                                                \
    GSF__ATT_FADE_ONE(to + (r) * GSF__ATT_PANEL, fades[r], c##r)                                                        \
    GSF__ATT_FADE_ONE(to + GSF__ATT_TILE + (r) * GSF__ATT_PANEL, fades[r], d##r)                                        \
    GSF__ATT_FADE_ONE(to + width + (r) * GSF__ATT_PANEL, fades[GSF__ATT_GROUP + (r)], e##r)                             \
    GSF__ATT_FADE_ONE(to + width + GSF__ATT_TILE + (r) * GSF__ATT_PANEL, fades[GSF__ATT_GROUP + (r)], f##r)
#define GSF__ATT_FADE_ONE(at, fade_, sum) \
    _mm512_storeu_ps(at, _mm512_fmadd_ps(_mm512_set1_ps(fade_), _mm512_loadu_ps(at), sum));

GSF__TARGET_AVX512 static void gsf__attention_values_avx512(const float* p, int64_t groups, const float* v, int64_t keys,
                                                            int64_t panels, const float* fade, float* out) {
    GSF__ATT_VALUES(gsf__nn_add_product, gsf__attention_values_avx2, keys)
}

// ---- attention in bf16: q and k are packed as pairs along head_dim, v and the weights as pairs along the keys

GSF__TARGET_BF16 static void gsf__attention_pack_pairs(const float* from, int64_t rows, int64_t ld, const float* center,
                                                       float factor, int64_t dim, float* to, int64_t to_ld) {
    const __m512 f = _mm512_set1_ps(factor);
    for (int64_t i = 0; i < dim; i += 16) {
        const __mmask16 mask = gsf__nn_mask16(dim - i);
        const __m512 c = center ? _mm512_maskz_loadu_ps(mask, center + i) : _mm512_setzero_ps();
        float units[8][8];
        for (int r = 0; r < 8; r++) {
            const __mmask16 there = r < rows ? mask : (__mmask16)0;
            const __m512 v = f * (_mm512_maskz_loadu_ps(there, from + r * ld + i) - c);
            _mm256_storeu_ps(units[r], _mm256_castsi256_ps(gsf__nn_round_bf16(v)));
        }
        if (dim - i >= 16)
            gsf__nn_transpose8(units[0], 8, _mm256_setzero_ps(), _mm256_set1_ps(1.0f), to + i / 2 * to_ld, to_ld);
        else
            for (int64_t u = 0; u < (dim - i) / 2; u++)
                for (int r = 0; r < 8; r++) to[(i / 2 + u) * to_ld + r] = units[r][u];
    }
}

GSF__TARGET_BF16 static void gsf__attention_pack_values_bf16(const gsf__attention_job* job, const float* from, int64_t keys,
                                                             float* packed) {
    const int64_t ld = job->desc.ldv, dim = job->desc.head_dim;
    for (int64_t j = 0; j < keys; j += 2) {
        gsf__attention_fetch(from, j + GSF__ATT_AHEAD, keys, ld, dim);
        gsf__attention_fetch(from, j + 1 + GSF__ATT_AHEAD, keys, ld, dim);
        for (int64_t i = 0; i < job->panels * GSF__ATT_PANEL; i += GSF__ATT_PANEL) {
            const __mmask16 mask = gsf__nn_mask16(dim - i), second = j + 1 < keys ? mask : (__mmask16)0;
            const __m256i low = gsf__nn_round_bf16(_mm512_maskz_loadu_ps(mask, from + j * ld + i));
            const __m256i high = gsf__nn_round_bf16(_mm512_maskz_loadu_ps(second, from + (j + 1) * ld + i));
            const __m512i pair = _mm512_or_si512(_mm512_cvtepu16_epi32(low),
                                                 _mm512_slli_epi32(_mm512_cvtepu16_epi32(high), 16));
            _mm512_storeu_si512(packed + (i * GSF__ATT_KEYS / GSF__ATT_PANEL + j / 2) * GSF__ATT_PANEL, pair);
        }
    }
}

GSF__TARGET_BF16 static void gsf__attention_logits_one_bf16(const float* q, int64_t groups, const float* k, int64_t panels,
                                                            int64_t dim, float* p) {
    for (int64_t panel = 0; panel < panels; panel++, k += GSF__ATT_PANEL * dim)
        for (int64_t g = 0; g < groups; g++) {
            __m512 c[GSF__ATT_GROUP];
            float* to = p + g * GSF__ATT_GROUP * GSF__ATT_KEYS + panel * GSF__ATT_PANEL;
            gsf__nn_tile_bf16(q + g * 8 * dim, 1, 8, k, dim, c);
            for (int r = 0; r < GSF__ATT_GROUP; r++) _mm512_storeu_ps(to + r * GSF__ATT_KEYS, c[r]);
        }
}

GSF__TARGET_BF16 static void gsf__attention_logits_bf16(const float* q, int64_t groups, const float* k, int64_t panels,
                                                        int64_t dim, float* p) {
    GSF__ATT_LOGITS(gsf__nn_add_pairs, gsf__attention_logits_one_bf16)
}

// Overwrites the logits with the weights in bf16, 16 keys in 8 slots; `sum` adds up the rounded weights.
GSF__TARGET_BF16 static void gsf__attention_weights_bf16(float* p, int64_t queries, int64_t columns, float* top, float* sum,
                                                         float fade[GSF__ATT_QUERIES]) {
    const gsf__v_exp2_terms_avx512 terms = gsf__v_exp2_of_avx512(1);
    gsf__attention_tops_avx512(p, queries, columns, top, fade);
    for (int64_t r = 0; r < queries; r++) {
        float* row = p + r * GSF__ATT_KEYS;
        const __m512 t = _mm512_set1_ps(top[r]);
        __m512 total = _mm512_setzero_ps();
        for (int64_t j = 0; j < columns; j += 16) {
            const __m256i weight = gsf__nn_round_bf16(gsf__v_exp2_low_avx512(&terms, _mm512_loadu_ps(row + j) - t));
            _mm256_storeu_si256((__m256i*)(void*)(row + j / 2), weight);
            total = total + _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(weight), 16));
        }
        gsf__attention_add_total(total, fade[r], sum + 8 * r);
    }
}

GSF__TARGET_BF16 static void gsf__attention_values_one_bf16(const float* p, int64_t groups, const float* v, int64_t keys,
                                                            int64_t panels, const float* fade, float* out) {
    for (int64_t panel = 0; panel < panels; panel++, v += GSF__ATT_KEYS * GSF__ATT_PANEL)
        for (int64_t g = 0; g < groups; g++) {
            __m512 c[GSF__ATT_GROUP];
            float* to = out + (g * panels + panel) * GSF__ATT_TILE;
            gsf__nn_tile_bf16(p + g * GSF__ATT_GROUP * GSF__ATT_KEYS, GSF__ATT_KEYS, 1, v, (keys + 1) / 2, c);
            for (int r = 0; r < GSF__ATT_GROUP; r++, to += GSF__ATT_PANEL)
                GSF__ATT_FADE_ONE(to, fade[g * GSF__ATT_GROUP + r], c[r])
        }
}

GSF__TARGET_BF16 static void gsf__attention_values_bf16(const float* p, int64_t groups, const float* v, int64_t keys,
                                                        int64_t panels, const float* fade, float* out) {
    GSF__ATT_VALUES(gsf__nn_add_pairs, gsf__attention_values_one_bf16, (keys + 1) / 2)
}

GSF__TARGET_AVX2 static void gsf__attention_finish(const gsf__attention_job* job, const gsf__attention_scratch* s,
                                                   int64_t queries, float* out, float* lse) {
    const int64_t dim = job->desc.head_dim, ld = job->desc.ldo;
    for (int64_t r = 0; r < queries; r++) {
        gsf__attention_fetch(out, r + GSF__ATT_AHEAD, queries, ld, dim);
        const float total = gsf__v_sum_avx2(_mm256_loadu_ps(s->sum + 8 * r));
        if (lse) lse[r] = gsf__attention_lse(s->top[r], total);
        const float* from = s->out + r / GSF__ATT_GROUP * job->panels * GSF__ATT_TILE + r % GSF__ATT_GROUP * GSF__ATT_PANEL;
        const __m256 divisor = _mm256_set1_ps(total);
        for (int64_t i = 0; i < dim; i += 8) {
            const __m256 value = _mm256_loadu_ps(from + i / GSF__ATT_PANEL * GSF__ATT_TILE + i % GSF__ATT_PANEL) / divisor;
            _mm256_maskstore_ps(out + r * ld + i, gsf__nn_mask8(dim - i), total == 0.0f ? _mm256_setzero_ps() : value);
        }
    }
}

static void gsf__attention_chunk_packed(const gsf__attention_job* job, size_t chunk, int32_t worker) {
    const gsf__attention_parts* parts = job->parts;
    const gsf__nn_attention_desc* d = &job->desc;
    const gsf__attention_scratch s = gsf__attention_scratch_of(job, worker);
    const int64_t head = (int64_t)chunk / job->ranges, first = (int64_t)chunk % job->ranges * job->range_size;
    const int64_t rows = gsf__least(job->range_size, d->queries - first);
    const int64_t groups = (rows + GSF__ATT_GROUP - 1) / GSF__ATT_GROUP, column = head * d->head_dim;
    const int64_t length = d->head_dim / parts->unit; // slots per query or key
    float fade[GSF__ATT_QUERIES];
    gsf__attention_center(d, column, s.center);
    gsf__attention_pack_queries(job, parts, d->q + first * d->ldq + column, rows, s.q);
    memset(s.out, 0, (size_t)(groups * job->panels * GSF__ATT_TILE) * sizeof(float));
    memset(s.sum, 0, (size_t)(groups * GSF__ATT_GROUP * 8) * sizeof(float));
    for (int64_t r = 0; r < groups * GSF__ATT_GROUP; r++) s.top[r] = -FLT_MAX;
    for (int64_t key = 0; key < d->keys; key += GSF__ATT_KEYS) {
        const int64_t keys = gsf__least(GSF__ATT_KEYS, d->keys - key);
        const int64_t key_panels = (keys + GSF__ATT_PANEL - 1) / GSF__ATT_PANEL, columns = key_panels * GSF__ATT_PANEL;
        gsf__attention_pack_keys(job, parts, d->k + key * d->ldk + column, s.center, keys, s.k);
        parts->pack_values(job, d->v + key * d->ldv + column, keys, s.v);
        for (int64_t g = 0; g < groups; g += GSF__ATT_GROUPS) {
            const int64_t count = gsf__least(GSF__ATT_GROUPS, groups - g), r = g * GSF__ATT_GROUP;
            parts->logits(s.q + g * 8 * length, count, s.k, key_panels, length, s.p);
            const int64_t at = (head * d->queries + first + r) * d->keys + key; // into mask and bias
            const unsigned char* mask = d->mask ? d->mask + at : NULL;
            if (d->bias) gsf__attention_bias(d->bias + at, d->keys, rows - r, keys, s.p);
            if (mask || keys < columns) gsf__attention_hide(mask, d->keys, rows - r, keys, columns, s.p);
            parts->weights(s.p, count * GSF__ATT_GROUP, columns, s.top + r, s.sum + 8 * r, fade);
            parts->values(s.p, count, s.v, keys, job->panels, fade, s.out + g * job->panels * GSF__ATT_TILE);
        }
    }
    gsf__attention_finish(job, &s, rows, d->out + first * d->ldo + column, d->lse ? d->lse + head * d->queries + first : NULL);
}

#endif // GSF__X86

static const gsf__attention_parts* gsf__attention_parts_of(gsf_cpu_level level, int pairs) { // pairs: bf16 operands
#if GSF__X86
    static const gsf__attention_parts avx2 = {
        1, gsf__attention_pack_rows, gsf__attention_pack_values,
        gsf__attention_logits_avx2,  gsf__attention_weights_avx2, gsf__attention_values_avx2};
    static const gsf__attention_parts avx512 = {
        1, gsf__attention_pack_rows, gsf__attention_pack_values,
        gsf__attention_logits_avx512, gsf__attention_weights_avx512, gsf__attention_values_avx512};
    static const gsf__attention_parts bf16 = {
        2, gsf__attention_pack_pairs, gsf__attention_pack_values_bf16,
        gsf__attention_logits_bf16, gsf__attention_weights_bf16, gsf__attention_values_bf16};
    if (level >= GSF_CPU_AVX512_BF16 && pairs) return &bf16;
    if (level >= GSF_CPU_AVX512) return &avx512;
    if (level >= GSF_CPU_AVX2) return &avx2;
#endif
    (void)pairs;
    (void)level;
    return NULL;
}

static void gsf__attention_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__attention_job* job = (const gsf__attention_job*)arg;
#if GSF__X86
    if (job->parts) gsf__attention_chunk_packed(job, chunk, worker);
#endif
    if (!job->parts) gsf__attention_chunk_scalar(job, chunk, worker);
}

static void gsf__attention_fill_in(gsf__nn_attention_desc* d) { // defaults
    const int64_t width = (int64_t)d->heads * d->head_dim;
    if (!d->ldq) d->ldq = width;
    if (!d->ldk) d->ldk = width;
    if (!d->ldv) d->ldv = width;
    if (!d->ldo) d->ldo = width;
    if (d->scale == 0.0f) d->scale = 1.0f / sqrtf((float)d->head_dim);
}

// Chooses the ranges of queries by the sizes only; returns the number of chunks.
static size_t gsf__attention_plan(gsf__attention_job* job) {
    const gsf__nn_attention_desc* d = &job->desc;
    const int64_t wanted = (GSF__ATT_CHUNKS - 1) / d->heads + 1, most = d->queries / GSF__ATT_LEAST_RANGE;
    job->ranges = (d->queries + GSF__ATT_RANGE - 1) / GSF__ATT_RANGE;
    if (job->ranges < wanted) job->ranges = wanted < most ? wanted : most > job->ranges ? most : job->ranges;
    if (job->ranges < 1) return 0;
    const int64_t size = (d->queries - 1) / job->ranges + 1;
    job->range_size = (size + GSF__ATT_GROUP - 1) / GSF__ATT_GROUP * GSF__ATT_GROUP;
    job->ranges = (d->queries - 1) / job->range_size + 1; // rounding up may leave the last ones empty
    return (size_t)(d->heads * job->ranges);
}

// Floats of scratch per worker, a multiple of 16; 0 on overflow.
static size_t gsf__attention_floats(const gsf__attention_job* job) {
    const gsf__nn_attention_desc* d = &job->desc;
    const size_t dim = (size_t)d->head_dim, padded = (size_t)job->panels * GSF__ATT_PANEL;
    size_t total;
    if (job->parts) { // p, k, v; then per query: out, sum, q (8 slots for 6 queries) and top
        if (!gsf__mul_size((size_t)job->range_size, padded + 8 + dim + (dim + 2) / 3 + 1, &total)) return 0;
        total += GSF__ATT_QUERIES * GSF__ATT_KEYS + GSF__ATT_KEYS * (dim + padded) + dim;
    } else {
        if (!gsf__mul_size((size_t)d->keys, GSF__ATT_ROWS, &total)) return 0;
        total += 2 * dim;
    }
    return total < SIZE_MAX / 8 ? (total + 15) / 16 * 16 : 0;
}

// softmax(scale q k^T + bias) v for every head, without storing the logits. NaNs propagate; a NaN in a row of v may
// also reach queries for which that row is masked.
static gsf_result gsf__nn_run_attention(gsf_context* ctx, gsf__nn_workspace* workspace,
                                        const gsf__nn_attention_desc* desc) {
    const int pairs = desc->bf16 && desc->head_dim % 2 == 0;
    gsf__nn_workspace own;
    gsf__attention_job job;
    size_t size;
    memset(&own, 0, sizeof own);
    memset(&job, 0, sizeof job);
    job.desc = *desc;
    job.parts = gsf__attention_parts_of(ctx->cpu_level, pairs);
    gsf__nn_attention_desc* d = &job.desc;
    if (!d->q || !d->k || !d->v || !d->out || d->queries < 0 || d->keys < 1 || d->heads < 1 || d->head_dim < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "attention: a tensor or a size is missing");
    gsf__attention_fill_in(d);
    job.panels = ((int64_t)d->head_dim + GSF__ATT_PANEL - 1) / GSF__ATT_PANEL;
    const size_t chunks = gsf__attention_plan(&job);
    job.scratch_floats = gsf__attention_floats(&job);
    if (!job.scratch_floats || !gsf__mul_size(job.scratch_floats, (size_t)ctx->parallel.worker_count, &size) ||
        !gsf__mul_size(size, sizeof(float), &size))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "attention: %lld keys are too many", (long long)d->keys);
    job.scratch = (float*)gsf__nn_scratch(ctx, workspace ? workspace : &own, size);
    if (!job.scratch) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__parallel_for(ctx, chunks, gsf__attention_chunk, &job);
    gsf__nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn convolution -----------------------------------------------------------

// In channels-last layout the 3C values left of, at and right of a pixel are contiguous, so a 3 x 3 (x 3) convolution
// is 3 (9) matrix products: for each kernel row (kt, ky), a row of output pixels is A (pixels, 3C), whose rows
// overlap by 2C, times B (3C, outputs). For this, frames get a column of zeros on either side; rows above and below the
// frame are skipped. Work is divided into segments of 8 x 30 output pixels. A segment computes 16 outputs at a time.
// Their weights are packed as (kernel row, 3C, 16) and divided into panels of up to 256 values x 16 (16 KiB, L1 cache).
// Each panel is multiplied with all pixels of the segment, 6 pixels x 16 outputs in registers. The sums of the panels
// are added one after another, so rounding errors grow with 256 + the number of panels instead of their product.

enum {
    GSF__CONV_M = 6, GSF__CONV_N = 16, GSF__CONV_K = 256, // pixels, outputs and values per product
    GSF__CONV_M10 = 10,                                   // pixels per product with two panels
    GSF__CONV_ROWS = 8, GSF__CONV_COLUMNS = 30,           // pixels per segment; columns: a multiple of M
    GSF__CONV_SHARE = GSF__CONV_N / GSF__CONV_ROWS,       // floats of the next panel to prefetch per step
    GSF__CONV_TAPS = 121,                                 // largest kernel: 11 x 11
};

typedef struct gsf__conv_kernels {
    // c += a b. a: `count` pixels, lda apart, k values each; b: (k, 16); c: (count rounded up to 6, 16), whose last
    // rows repeat the last pixel. Also prefetches GSF__CONV_SHARE k floats from `ahead` on.
    void (*multiply)(const float* a, int64_t lda, int64_t count, const float* b, int64_t k, float* c, const float* ahead);
    // The same for two panels, `b_next` floats apart, with sums `c_next` apart; may be NULL.
    void (*multiply_two)(const float* a, int64_t lda, int64_t count, const float* b, int64_t b_next, int64_t k, float* c,
                         int64_t c_next, const float* ahead);
    // out = c, or out += c, for `count` pixels, ldo apart, and n <= 16 outputs; sums (2, 16) += values and squares.
    void (*store)(const float* c, int64_t count, int64_t n, int accumulate, float* out, int64_t ldo, double* sums);
    // y = silu((x - mean) * scale + offset)
    void (*norm_silu)(const float* x, int64_t count, const float* mean, const float* scale, const float* offset, float* y);
} gsf__conv_kernels;

static void gsf__conv_multiply_ref(const float* a, int64_t lda, int64_t count, const float* b, int64_t k, float* c,
                                   const float* ahead) {
    (void)ahead;
    for (int64_t m = 0; m < count; m++)
        for (int n0 = 0; n0 < GSF__CONV_N; n0 += 4) {
            const float* w = b + n0;
            float* y = c + m * GSF__CONV_N + n0;
            float y0 = 0.0f, y1 = 0.0f, y2 = 0.0f, y3 = 0.0f;
            for (int64_t i = 0; i < k; i++, w += GSF__CONV_N) {
                const float x = a[m * lda + i];
                y0 += x * w[0], y1 += x * w[1], y2 += x * w[2], y3 += x * w[3];
            }
            y[0] += y0, y[1] += y1, y[2] += y2, y[3] += y3;
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

#if GSF__X86
GSF__INLINE_AVX2 void gsf__conv_add8(float* c, __m256 v) { _mm256_storeu_ps(c, _mm256_add_ps(_mm256_loadu_ps(c), v)); }

// Six pixels at a time; missing pixels repeat the last one.
GSF__TARGET_AVX2 static void gsf__conv_multiply_avx2(const float* a, int64_t lda, int64_t count, const float* b, int64_t k,
                                                     float* c, const float* ahead) {
    for (int64_t m = 0; m < count; m += GSF__CONV_M, a += GSF__CONV_M * lda, c += GSF__CONV_M * GSF__CONV_N) {
        const int64_t last = count - m - 1, share = m == 0 ? GSF__CONV_SHARE : 0;
        const float* w = b;
#define GSF_X(r)                                            \
        const float* a##r = a + gsf__least(r, last) * lda;  \
        __m256 c##r##0 = _mm256_setzero_ps(), c##r##1 = c##r##0;
        GSF__SIX(GSF_X)
#undef GSF_X
        for (int64_t i = 0; i < k; i++, w += GSF__CONV_N) {
            const __m256 w0 = _mm256_loadu_ps(w), w1 = _mm256_loadu_ps(w + 8);
            _mm_prefetch((const char*)ahead, _MM_HINT_T1);
            ahead += share;
            __m256 v;
#define GSF_X(r)                                           \
            v = _mm256_broadcast_ss(a##r + i);             \
            c##r##0 = _mm256_fmadd_ps(v, w0, c##r##0);     \
            c##r##1 = _mm256_fmadd_ps(v, w1, c##r##1);
            GSF__SIX(GSF_X)
#undef GSF_X
        }
#define GSF_X(r) gsf__conv_add8(c + GSF__CONV_N * r, c##r##0), gsf__conv_add8(c + GSF__CONV_N * r + 8, c##r##1);
        GSF__SIX(GSF_X)
#undef GSF_X
    }
}

// Ten pixels by two panels: 20 registers of sums. That leaves too few registers for ten pointers, so all pixels are
// addressed from three. The last ten pixels of a row may overlap earlier ones, whose sums are not added again.
GSF__TARGET_AVX512 static void gsf__conv_multiply_two_avx512(const float* a, int64_t lda, int64_t count, const float* b,
                                                             int64_t b_next, int64_t k, float* c, int64_t c_next,
                                                             const float* ahead) {
#define GSF_ROWS(X)                                                                   \
    X(0, a0, 0) X(1, a1, 0) X(2, a1, 1) X(3, a1, 2) X(4, a0, 4) X(5, a1, 4)           \
    X(6, a5, 1) X(7, a5, 2) X(8, a0, 8) X(9, a1, 8)
    const int64_t pitch = lda * (int64_t)sizeof(float);
    if (count < GSF__CONV_M10) {
        gsf__conv_multiply_avx2(a, lda, count, b, k, c, ahead);
        gsf__conv_multiply_avx2(a, lda, count, b + b_next, k, c + c_next, ahead + b_next);
        return;
    }
    for (int64_t m = 0; m < count; m += GSF__CONV_M10) {
        const int64_t done = m + GSF__CONV_M10 > count ? m + GSF__CONV_M10 - count : 0, share = m == 0 ? GSF__CONV_SHARE : 0;
        const char *a0 = (const char*)(a + (m - done) * lda), *a1 = a0 + pitch, *a5 = a0 + 5 * pitch;
        const float* w = b;
#define GSF_X(r, base, times) __m512 c##r = _mm512_setzero_ps(), d##r = c##r;
        GSF_ROWS(GSF_X)
#undef GSF_X
        for (int64_t i = 0; i < k; i++, w += GSF__CONV_N, a0 += 4, a1 += 4, a5 += 4) {
            const __m512 w0 = _mm512_loadu_ps(w), w1 = _mm512_loadu_ps(w + b_next);
            __m512 v;
            _mm_prefetch((const char*)ahead, _MM_HINT_T1);
            _mm_prefetch((const char*)(ahead + b_next), _MM_HINT_T1);
            ahead += share;
#define GSF_X(r, base, times)                                                             \
            v = _mm512_set1_ps(*(const float*)(const void*)(base + times * pitch));       \
            c##r = _mm512_fmadd_ps(v, w0, c##r);                                          \
            d##r = _mm512_fmadd_ps(v, w1, d##r);
            GSF_ROWS(GSF_X)
#undef GSF_X
        }
        float *to = c + (m - done) * GSF__CONV_N, *next = to + c_next;
#define GSF_X(r, base, times)                                                                              \
        if (r >= done) {                                                                                   \
            _mm512_storeu_ps(to + r * GSF__CONV_N, _mm512_loadu_ps(to + r * GSF__CONV_N) + c##r);          \
            _mm512_storeu_ps(next + r * GSF__CONV_N, _mm512_loadu_ps(next + r * GSF__CONV_N) + d##r);      \
        }
        GSF_ROWS(GSF_X)
#undef GSF_X
    }
#undef GSF_ROWS
}

GSF__INLINE_AVX2 void gsf__conv_add_squares(__m256d v, __m256d* sum, __m256d* square) {
    *sum = _mm256_add_pd(*sum, v);
    *square = _mm256_fmadd_pd(v, v, *square);
}

// Stores eight outputs of `count` pixels.
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

#endif

static const gsf__conv_kernels* gsf__conv_kernels_of(gsf_cpu_level level) {
    static const gsf__conv_kernels scalar = {gsf__conv_multiply_ref, NULL, gsf__conv_store_ref, gsf__norm_silu_scalar};
#if GSF__X86
    static const gsf__conv_kernels avx2 = {gsf__conv_multiply_avx2, NULL, gsf__conv_store_avx2, gsf__norm_silu_avx2};
    static const gsf__conv_kernels avx512 = {gsf__conv_multiply_avx2, gsf__conv_multiply_two_avx512, gsf__conv_store_avx2,
                                             gsf__norm_silu_avx512};
    if (level >= GSF_CPU_AVX512) return &avx512;
    if (level >= GSF_CPU_AVX2) return &avx2;
#endif
    (void)level;
    return &scalar;
}

typedef struct gsf__conv_layer { // weight: (out, in, kt, kernel, kernel); 2D: without kt
    const gsf_nn_tensor *weight, *bias;
    int64_t in, out, kt, kernel;
} gsf__conv_layer;

static int64_t gsf__conv_taps(const gsf__conv_layer* layer) { return layer->kt * layer->kernel * layer->kernel; }
static int64_t gsf__conv_blocks(const gsf__conv_layer* layer) { return (layer->out + GSF__CONV_N - 1) / GSF__CONV_N; }
// Floats per packed panel of 16 outputs: their bias, then their weights.
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

// Packs sixteen outputs: (out, in, taps) to (taps, in, 16), missing outputs zero. A few input channels at a time, so
// that both source and destination stay in the L1 cache.
static void gsf__conv_pack_block(void* arg, size_t block, int32_t worker) {
    enum { CHANNELS = 16 };
    const gsf__conv_pack_job* job = (const gsf__conv_pack_job*)arg;
    const gsf__conv_layer* layer = job->layer;
    const int64_t taps = gsf__conv_taps(layer), first = (int64_t)block * GSF__CONV_N;
    const int64_t n_end = gsf__least(layer->out - first, GSF__CONV_N);
    float* panel = job->out + (int64_t)block * gsf__conv_panel(layer);
    float* weights = panel + GSF__CONV_N;
    float values[CHANNELS * GSF__CONV_TAPS];
    (void)worker;
    if (n_end < GSF__CONV_N || !layer->bias) memset(panel, 0, (size_t)gsf__conv_panel(layer) * sizeof(float));
    if (layer->bias) gsf_nn_convert_tensor(layer->bias, first, n_end, panel);
    for (int64_t c0 = 0; c0 < layer->in; c0 += CHANNELS) {
        const int64_t channels = gsf__least(layer->in - c0, CHANNELS);
        for (int64_t n = 0; n < n_end; n++) {
            gsf_nn_convert_tensor(layer->weight, ((first + n) * layer->in + c0) * taps, channels * taps, values);
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

// A 3 x 3 convolution of a frame upscaled 2x by nearest neighbour equals four 2 x 2 convolutions of the frame itself,
// one per parity (py, px) of the output pixel: kernel rows that fall on the same input row are added up. At parity 0
// the two rows are the sums of the kernel's rows {0} and {1, 2}, at parity 1 of {0, 1} and {2}. This takes 4/9 of the
// multiply-adds.
static gsf__conv_layer gsf__conv_quarter(const gsf__conv_layer* layer) { // the convolution for one parity
    gsf__conv_layer quarter = *layer;
    quarter.kernel = 2;
    return quarter;
}

static void gsf__conv_pack_quarter(void* arg, size_t chunk, int32_t worker) { // chunk: one parity and 16 outputs
    const gsf__conv_pack_job* job = (const gsf__conv_pack_job*)arg;
    const gsf__conv_layer* layer = job->layer;
    const gsf__conv_layer quarter = gsf__conv_quarter(layer);
    const int64_t blocks = gsf__conv_blocks(layer), parity = (int64_t)chunk / blocks, in = layer->in;
    const int64_t first = (int64_t)chunk % blocks * GSF__CONV_N, n_end = gsf__least(layer->out - first, GSF__CONV_N);
    float* panel = job->out + (int64_t)chunk * gsf__conv_panel(&quarter);
    (void)worker;
    memset(panel, 0, (size_t)gsf__conv_panel(&quarter) * sizeof(float));
    if (layer->bias) gsf_nn_convert_tensor(layer->bias, first, n_end, panel);
    for (int64_t c = 0; c < in; c++)
        for (int64_t n = 0; n < n_end; n++) {
            float values[9] = {0};
            gsf_nn_convert_tensor(layer->weight, ((first + n) * in + c) * 9, 9, values);
            for (int64_t y = 0; y < 3; y++)
                for (int64_t x = 0; x < 3; x++) {
                    const int64_t row = y > parity / 2, column = x > parity % 2;
                    panel[GSF__CONV_N * (1 + (row * 2 + column) * in + c) + n] += values[y * 3 + x];
                }
        }
}

// out: (parities, blocks, panel of a quarter)
static void gsf__conv_pack_quarters(gsf_context* ctx, const gsf__conv_layer* layer, float* out) {
    gsf__conv_pack_job job = {layer, out};
    gsf__parallel_for(ctx, (size_t)gsf__conv_blocks(layer) * 4, gsf__conv_pack_quarter, &job);
}

typedef struct gsf__conv_job { // one frame of output
    const gsf__conv_kernels* kernels;
    const float* in[3];              // kt input frames, oldest first
    int64_t in_height, in_stride;    // rows and floats per row of an input frame
    int64_t origin, step;            // floats from a row's start to the input of output column 0; between columns
    int64_t kt, kh, k;               // kt x kh kernel rows of k values
    int64_t stride, pad;             // of rows
    const float* packed;
    int64_t panel;
    int64_t height, width, outputs;
    float* out;                      // ldo floats between pixels, out_row between rows
    int64_t ldo, out_row;
    int32_t accumulate;
    int64_t groups;                  // of outputs
    double* partial;                 // (segments, groups, 2): sums and sums of squares; may be NULL
} gsf__conv_job;

static int64_t gsf__conv_columns(const gsf__conv_job* job) {
    return (job->width + GSF__CONV_COLUMNS - 1) / GSF__CONV_COLUMNS;
}
static int64_t gsf__conv_segments(const gsf__conv_job* job) {
    return (job->height + GSF__CONV_ROWS - 1) / GSF__CONV_ROWS * gsf__conv_columns(job);
}

enum { GSF__CONV_TILE = GSF__CONV_ROWS * GSF__CONV_COLUMNS * GSF__CONV_N };

// tiles (panels, rows, 30, 16) += the products of all kernel rows with one or two panels of outputs.
static void gsf__conv_sum(const gsf__conv_job* job, int64_t y0, int64_t rows, int64_t x0, int64_t columns, int64_t panels,
                          const float* b, float* tile) {
    for (int64_t kt = 0; kt < job->kt; kt++)
        for (int64_t kh = 0; kh < job->kh; kh++)
            for (int64_t k0 = 0; k0 < job->k; k0 += GSF__CONV_K) {
                const int64_t k = gsf__least(job->k - k0, GSF__CONV_K);
                for (int64_t r = 0; r < rows; r++) {
                    const int64_t y = (y0 + r) * job->stride + kh - job->pad;
                    if (y < 0 || y >= job->in_height) continue;
                    const float* a = job->in[kt] + y * job->in_stride + job->origin + x0 * job->step + k0;
                    const float* ahead = b + (GSF__CONV_N + r * GSF__CONV_SHARE) * k; // the rows share the prefetching
                    float* c = tile + r * GSF__CONV_COLUMNS * GSF__CONV_N;
                    if (panels == 2)
                        job->kernels->multiply_two(a, job->step, columns, b, job->panel, k, c, GSF__CONV_TILE, ahead);
                    else job->kernels->multiply(a, job->step, columns, b, k, c, ahead);
                }
                b += k * GSF__CONV_N;
            }
}

// Writes a tile to outputs n0 ... of its pixels; adds its values and their squares to `partial` (may be NULL).
static void gsf__conv_store(const gsf__conv_job* job, const float* tile, int64_t y0, int64_t rows, int64_t x0,
                            int64_t columns, int64_t n0, double* partial) {
    const int64_t n = gsf__least(job->outputs - n0, GSF__CONV_N);
    double sums[2 * GSF__CONV_N];
    memset(sums, 0, sizeof sums);
    for (int64_t r = 0; r < rows; r++)
        job->kernels->store(tile + r * GSF__CONV_COLUMNS * GSF__CONV_N, columns, n, job->accumulate,
                            job->out + (y0 + r) * job->out_row + x0 * job->ldo + n0, job->ldo, sums);
    for (int64_t i = 0; partial && i < n; i++) {
        const int64_t group = (n0 + i) / (job->outputs / job->groups);
        partial[2 * group] += sums[i];
        partial[2 * group + 1] += sums[GSF__CONV_N + i];
    }
}

static void gsf__conv_segment(void* arg, size_t segment, int32_t worker) {
    const gsf__conv_job* job = (const gsf__conv_job*)arg;
    const int64_t across = gsf__conv_columns(job);
    const int64_t y0 = (int64_t)segment / across * GSF__CONV_ROWS, x0 = (int64_t)segment % across * GSF__CONV_COLUMNS;
    const int64_t rows = gsf__least(job->height - y0, GSF__CONV_ROWS);
    const int64_t columns = gsf__least(job->width - x0, GSF__CONV_COLUMNS);
    double* partial = job->partial ? job->partial + (int64_t)segment * job->groups * 2 : NULL;
    float tiles[2 * GSF__CONV_TILE];
    (void)worker;
    if (partial) memset(partial, 0, (size_t)job->groups * 2 * sizeof(double));
    for (int64_t n0 = 0, panels; n0 < job->outputs; n0 += panels * GSF__CONV_N) {
        const float* b = job->packed + n0 / GSF__CONV_N * job->panel; // bias, then weights
        panels = job->kernels->multiply_two && job->outputs - n0 > GSF__CONV_N ? 2 : 1;
        for (int64_t p = 0; p < panels; p++)
            for (int64_t i = 0; i < rows * GSF__CONV_COLUMNS; i++)
                memcpy(tiles + p * GSF__CONV_TILE + i * GSF__CONV_N, b + p * job->panel, GSF__CONV_N * sizeof(float));
        gsf__conv_sum(job, y0, rows, x0, columns, panels, b + GSF__CONV_N, tiles);
        for (int64_t p = 0; p < panels; p++)
            gsf__conv_store(job, tiles + p * GSF__CONV_TILE, y0, rows, x0, columns, n0 + p * GSF__CONV_N, partial);
    }
}

// Convolves one frame; if job->partial is not NULL, writes the sums per group to `sums` (groups, 2).
static void gsf__conv_frame(gsf_context* ctx, gsf__conv_job* job, double* sums) {
    const int64_t segments = gsf__conv_segments(job);
    gsf__parallel_for(ctx, (size_t)segments, gsf__conv_segment, job);
    if (!job->partial || !sums) return;
    memset(sums, 0, (size_t)job->groups * 2 * sizeof(double));
    for (int64_t s = 0; s < segments; s++)
        for (int64_t i = 0; i < job->groups * 2; i++) sums[i] += job->partial[s * job->groups * 2 + i];
}

typedef struct gsf__conv_fill { // prepares one frame: norm and activation, averaging, border
    const gsf__conv_kernels* kernels;
    const float *x, *x2;             // (height, width, channels); x2: averaged with x, or NULL
    int64_t height, width, channels;
    const float *mean, *table;       // mean NULL: no norm. table: scale and offset per pixel of a coarser frame
    int64_t table_width;             // (.., table_width, 2, channels); 0: one scale and offset for all pixels
    int32_t shift;                   // log2 of the pixels per pixel of the table, along a side
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

static void gsf__conv_fill_rows(void* arg, size_t chunk, int32_t worker) {
    const gsf__conv_fill* job = (const gsf__conv_fill*)arg;
    (void)worker;
    const int64_t begin = (int64_t)chunk * GSF__CONV_FILL_ROWS;
    for (int64_t y = begin; y < begin + GSF__CONV_FILL_ROWS && y < job->height; y++) gsf__conv_fill_row(job, y);
}

static void gsf__conv_fill_frame(gsf_context* ctx, gsf__conv_fill* job) {
    gsf__parallel_for(ctx, (size_t)((job->height + GSF__CONV_FILL_ROWS - 1) / GSF__CONV_FILL_ROWS), gsf__conv_fill_rows,
                      job);
}

static int64_t gsf__conv_frame_size(int64_t height, int64_t width, int64_t channels) { // floats, including the border
    return height * (width + 2) * channels;
}

// Initialises the members that frames of one size share: bordered input frames of `in_height` x `in_width`.
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

static gsf_result gsf__check_conv(gsf_context* ctx, const gsf__nn_conv_desc* desc, gsf__conv_layer* layer) {
    const gsf_nn_tensor* w = desc->weight;
    memset(layer, 0, sizeof *layer);
    if (!desc->x || !desc->y || !w || desc->frames < 1 || desc->height < 1 || desc->width < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convolution: x, y, weight or a size is missing");
    if (w->dtype != GSF_NN_F32 && w->dtype != GSF_NN_BF16 && w->dtype != GSF_NN_F16)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "convolution: %s is %s", w->name, gsf__nn_dtype_name(w->dtype));
    const int64_t kernel = w->rank == 4 || w->rank == 5 ? w->shape[w->rank - 1] : 0, kt = w->rank == 5 ? w->shape[2] : 1;
    if ((kernel != 1 && kernel != 3) || w->shape[w->rank - 2] != kernel || (kt != 1 && kt != 3) || w->count < 1)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "convolution: %s is not a kernel of 1 or 3 x 1 or 3 x 3", w->name);
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

// A convolution; 3D ones are causal in time. `workspace` holds the widened weights and three frames of the input with
// their borders; if it is NULL, memory is allocated for this call.
GSF__SHARED gsf_result gsf__nn_convolve(gsf_context* ctx, gsf__nn_workspace* workspace, const gsf__nn_conv_desc* desc) {
    gsf__conv_layer layer;
    gsf__nn_workspace own;
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
        for (int64_t i = 0; i < layer.kt; i++) { // the first frame is repeated before itself
            const int64_t source = t - layer.kt + 1 + i;
            job.in[i] = memory + (size_t)(source < 0 && !desc->before ? 0 : (source + 3) % 3) * frame;
        }
        job.out = desc->y + t * job.height * job.width * layer.out;
        gsf__conv_frame(ctx, &job, NULL);
    }
    gsf__nn_destroy_workspace(ctx, &own);
    return GSF_OK;
}

// ---- >>nn positions -------------------------------------------------------------

// torch.linspace in float32: computed from both ends towards the middle, with fused multiply-adds.
static float gsf__nn_linspace(float start, float end, int32_t count, int32_t i) {
    if (count == 1) return start;
    const float step = (end - start) / (float)(count - 1);
    return i < count / 2 ? fmaf(step, (float)i, start) : fmaf(-step, (float)(count - 1 - i), end);
}

// The position of a height x width grid in the base grid after resizing it to fit: first[0], last[0] are rows, [1]
// columns; last is exclusive. Rounds half to even as Python does; so does rint in the default rounding mode.
static void gsf__nn_fit_grid(const gsf__nn_rope_desc* desc, double first[2], double last[2]) {
    const double th = desc->base_height, tw = desc->base_width, h = desc->height, w = desc->width;
    const int tall = h / w > th / tw;
    const double rows = tall ? th : rint(tw / w * h), columns = tall ? rint(th / h * w) : tw;
    first[0] = rint((th - rows) / 2.0);
    first[1] = rint((tw - columns) / 2.0);
    last[0] = first[0] + rows;
    last[1] = first[1] + columns;
}

// cosine, sine: (count, dim), of one axis at the positions linspace(start, end, count).
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
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: dimension %d is not a multiple of 16", what, (int)dim);
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

// Rotary table: cos, sin (frames*height*width, head_dim), with every value twice, for interleaved pairs. Pair i of an
// axis with d values is rotated by position * theta^(-2i/d). Positions of frames are 0, 1, ...; those of rows are
// linspace(top, bottom*(h-1)/h, h), where top and bottom are those of the grid after it is resized to fit into the base
// grid with its aspect ratio kept; columns alike. Angles are float32 products in diffusers' order, to match its tables
// rather than the exact values.
// (diffusers 0.32.1 embeddings.py get_3d_rotary_pos_embed, pipeline_cogvideox.py get_resize_crop_region_for_grid)
static gsf_result gsf__nn_make_rope(gsf_context* ctx, const gsf__nn_rope_desc* desc, float* cosine, float* sine) {
    GSF__TRY(gsf__nn_check_grid(ctx, "rope", desc->frames, desc->height, desc->width, desc->head_dim));
    if (desc->base_height < 1 || desc->base_width < 1 || !(desc->theta >= 0.0) || desc->theta > 1e30)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "rope: a base grid of %d x %d, theta %g", (int)desc->base_height,
                        (int)desc->base_width, desc->theta);
    const gsf__nn_axes axes = {desc->frames, desc->height, desc->width, desc->head_dim, 0};
    const int32_t counts[3] = {desc->frames, desc->height, desc->width};
    const double theta = desc->theta != 0.0 ? desc->theta : 10000.0;
    double first[3] = {0.0, 0.0, 0.0}, last[3] = {(double)desc->frames, 0.0, 0.0};
    float* table[3]; // per axis the cosines, then the sines
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

// out: (count, dim) of one axis, [sin | cos]. Positions are float32, as in diffusers' numpy code.
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

// Writes to `wide` or `narrow`, whichever is not NULL.
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

// Sine-cosine positions: out (frames*height*width, dim); dim, a multiple of 16, is split into time dim/4 | columns
// 3*dim/8 | rows 3*dim/8, each [sin | cos] of position/scale * 10000^(-i/(d/2)). Computed in double. Scale 0 means 1.
// (diffusers 0.32.1 embeddings.py get_3d_sincos_pos_embed)
static gsf_result gsf__nn_make_sincos(gsf_context* ctx, int32_t frames, int32_t height, int32_t width, int32_t dim,
                                      double spatial_scale, double temporal_scale, float* out) {
    const gsf__nn_axes axes = {frames, height, width, dim, 1};
    return gsf__nn_sincos(ctx, &axes, spatial_scale != 0.0 ? spatial_scale : 1.0,
                          temporal_scale != 0.0 ? temporal_scale : 1.0, NULL, out);
}

// Embedding of a diffusion time step (0..999): out (dim) = [cos | sin] of t * exp(-ln(10000) i / (dim/2)); the last
// value of an odd dim is 0. Angles are float32, as in diffusers.
// (diffusers 0.32.1 get_timestep_embedding, flip_sin_to_cos)
static void gsf__nn_embed_timestep(double timestep, int32_t dim, float* out) {
    const int32_t half = dim / 2;
    if (dim % 2 != 0) out[dim - 1] = 0.0f;
    for (int32_t i = 0; i < half; i++) {
        const float exponent = -9.210340371976184f * (float)i / (float)half; // -ln(10000) i / half
        const float angle = (float)timestep * (float)exp((double)exponent);
        out[i] = (float)cos((double)angle);
        out[half + i] = (float)sin((double)angle);
    }
}

// ---- >>nn layers ----------------------------------------------------------------
/* The building blocks that the networks share. A network consists of
     a struct whose members are gsf__nn_layer, or const gsf_nn_tensor* for tensors without a layer;
     a table of gsf__nn_entry: the name, shape and struct offset of each member. gsf__nn_visit walks it: gsf__nn_bind
       to look up all tensors in a file, bench/make_model.c to generate them;
     a gsf__nn_run: what a forward pass needs besides the layers, from the context to the scratch memory.
   A forward pass calls gsf__nn_linear, gsf__nn_add, gsf__nn_norm, gsf__nn_attend and the like, but no kernels.
   Networks made of identical pre-norm blocks share gsf__nn_block: DINOv2, VGGT, BLIP-2's vision encoder
   (>>nn image encoders), OPT (>>nn captioner) and T5 (>>nn t5). */

typedef struct gsf__nn_layer { // linear: (out, in), (out); norm: (width), (width); NULL: not in this network
    const gsf_nn_tensor *weight, *bias;
} gsf__nn_layer;

// ---- layers: tables of tensors

typedef enum gsf__nn_form {
    GSF__NN_PAIR = 0, // a gsf__nn_layer: NAME.weight of the entry's shape, NAME.bias of its first dimension
    GSF__NN_BIASED,   // the same, but without a bias where the network lacks the entry's option
    GSF__NN_WEIGHT,   // NAME.weight only
    GSF__NN_TENSOR,   // NAME itself
} gsf__nn_form;

typedef struct gsf__nn_entry { // a table ends with an entry whose name is NULL
    const char *name, *shape;  // one letter per dimension: a letter of gsf__nn_sizes, '1': one, '?': any
    size_t offset;          // of the gsf__nn_layer or const gsf_nn_tensor* in the network's struct
    gsf__nn_form form;
    char option;               // a letter whose size is 0 if the network lacks this entry; 0: always present
} gsf__nn_entry;

#define GSF__NN_AT(type, member) offsetof(type, member), GSF__NN_PAIR, 0
#define GSF__NN_END {NULL, NULL, 0, GSF__NN_PAIR, 0}

typedef struct gsf__nn_sizes { // dimensions of a network, by letter; letter 0 ends the list
    struct { char letter; int64_t size; } of[16];
} gsf__nn_sizes;

static int64_t gsf__nn_size_of(const gsf__nn_sizes* sizes, char letter) {
    for (size_t i = 0; sizes->of[i].letter; i++)
        if (sizes->of[i].letter == letter) return sizes->of[i].size;
    return letter == '1' ? 1 : -1;
}

// Called once per tensor; *to is a member of the network's struct.
typedef gsf_result (*gsf__nn_visit_fn)(void* user, const char* name, int32_t rank, const int64_t* shape,
                                       const gsf_nn_tensor** to);

static gsf_result gsf__nn_visit_entry(const gsf__nn_sizes* sizes, const gsf__nn_entry* e, const char* prefix, void* where,
                                      gsf__nn_visit_fn fn, void* user) {
    const int has_option = !e->option || gsf__nn_size_of(sizes, e->option) != 0;
    const gsf_nn_tensor** to = (const gsf_nn_tensor**)(void*)((char*)where + e->offset);
    int64_t shape[GSF_NN_MAX_RANK];
    int32_t rank = 0;
    char name[200];
    memset(shape, 0, sizeof shape);
    if (!has_option && e->form != GSF__NN_BIASED) return GSF_OK;
    for (const char* letter = e->shape; *letter; letter++) shape[rank++] = gsf__nn_size_of(sizes, *letter);
    snprintf(name, sizeof name, "%s%s%s", prefix, e->name, e->form == GSF__NN_TENSOR ? "" : ".weight");
    GSF__TRY(fn(user, name, rank, shape, to));
    if (!has_option || e->form == GSF__NN_WEIGHT || e->form == GSF__NN_TENSOR) return GSF_OK;
    snprintf(name, sizeof name, "%s%s.bias", prefix, e->name);
    return fn(user, name, 1, shape, to + 1);
}

// Visits all tensors of a table, with `prefix` before each name, for the struct at `where`.
static gsf_result gsf__nn_visit(const gsf__nn_sizes* sizes, const gsf__nn_entry* entries, const char* prefix, void* where,
                                gsf__nn_visit_fn fn, void* user) {
    for (const gsf__nn_entry* e = entries; e->name; e++)
        GSF__TRY(gsf__nn_visit_entry(sizes, e, prefix, where, fn, user));
    return GSF_OK;
}

static gsf_result gsf__nn_take_visited(void* user, const char* name, int32_t rank, const int64_t* shape,
                                       const gsf_nn_tensor** to) {
    return gsf__nn_take((gsf__nn_loader*)user, name, to, rank, shape);
}

static gsf_result gsf__nn_bind(gsf__nn_loader* loader, const gsf__nn_sizes* sizes, const gsf__nn_entry* entries,
                               const char* prefix, void* where) {
    return gsf__nn_visit(sizes, entries, prefix, where, gsf__nn_take_visited, loader);
}

// Binds `count` structs of `size` bytes at `blocks`, whose tensors are named NAMES0.*, NAMES1.*, ...
static gsf_result gsf__nn_bind_each(gsf__nn_loader* loader, const gsf__nn_sizes* sizes, const gsf__nn_entry* entries,
                                    const char* names, int64_t count, size_t size, void* blocks) {
    char prefix[96];
    for (int64_t i = 0; i < count; i++) {
        snprintf(prefix, sizeof prefix, "%s%lld.", names, (long long)i);
        GSF__TRY(gsf__nn_bind(loader, sizes, entries, prefix, (char*)blocks + (size_t)i * size));
    }
    return GSF_OK;
}

// Loads a network from FOLDER/config.json and FOLDER/PREFIX*.safetensors: `read` parses the config, `bind` looks up the
// tensors. On error the caller destroys whatever has been loaded by then.
static gsf_result gsf__nn_open_network(gsf_context* ctx, const char* folder, const char* prefix,
                                       gsf_result (*read)(const gsf__nn_config* file, void* network),
                                       gsf_result (*bind)(gsf__nn_loader* loader, void* network), void* network,
                                       gsf_nn_weights* weights) {
    gsf__nn_config file;
    gsf__nn_loader loader;
    gsf_result result = gsf__nn_open_config(ctx, folder, "config.json", 0, &file);
    if (!result) result = read(&file, network);
    gsf__nn_close_config(&file);
    if (!result) result = gsf_nn_load_weights(ctx, folder, prefix, weights);
    if (result) return result;
    GSF__TRY(gsf__nn_begin_loading(ctx, weights, &loader));
    return gsf__nn_end_loading(&loader, bind(&loader, network));
}

// ---- layers: state of a forward pass

typedef struct gsf__nn_block_sizes { // of the network's blocks
    int64_t width, mlp;              // of a token; of the MLP's hidden layer
    int32_t heads, head_dim;
    float eps, head_eps;             // of the block's norms; of the norms of q and k
    gsf__nn_activation activation;
    int qkv_bias, head_norm;         // q, k and v have biases; q and k have a LayerNorm per head
    int rms, gated;                  // RMSNorm instead of LayerNorm; gated MLP
} gsf__nn_block_sizes;

typedef struct gsf__nn_cache { // keys and values of earlier tokens
    int64_t capacity, past;    // in tokens: allocated; in use
    float *keys, *values;      // (layers, capacity, width)
    unsigned char* mask;       // (heads, tokens, tokens), causal; used when several tokens are added at once
} gsf__nn_cache;

typedef struct gsf__nn_run {
    gsf_context* ctx;
    const char *name, *stage;          // of the network, for error messages; for progress
    const gsf_nn_weights* weights;     // searched for the source of a NaN
    const gsf__nn_quantized* quantized; // one per tensor of the file, empty if not quantized; NULL: no tensor is
    int32_t bf16;                     // see gsf__nn_linear_desc
    const gsf__nn_tap* tap;
    char label[48];                    // prefix for the names of a block's intermediates; empty: not shown to the tap
    gsf__nn_workspace workspace;
    float* vectors;                    // the current layer's vectors as float32; room for the two longest
    size_t vectors_size;
    double done, steps;                // progress, in blocks
    // only for networks of gsf__nn_block:
    const gsf__nn_block_sizes* sizes;
    float* normed;                     // (rows, the larger of width and heads * head_dim)
    float* wide;                       // (rows, 3 heads * head_dim): q | k | v of each row; also the MLP's hidden rows
    int64_t wide_count;                // capacity of `wide` in floats
    const float* bias;                 // (heads, tokens, tokens), added to the logits, or NULL
    float scale;                       // of the logits; 0: 1 / sqrt(head_dim)
    gsf__nn_cache* cache;              // NULL: none
    const float *cos, *sin;            // (positions, head_dim / 4) for positions 1, 2, ...; NULL: no rotation
    // patch grid of RoPE: tokens per image, leading ones without position, patches per row
    int64_t image_tokens, special, across;
} gsf__nn_run;

// Divides one allocation into parts. The layout runs twice: without `memory` it only counts.
typedef struct gsf__nn_arena {
    float* memory;
    size_t used; // in floats; SIZE_MAX, which no allocator can provide, on overflow
} gsf__nn_arena;

static float* gsf__nn_share(gsf__nn_arena* arena, size_t count) {
    float* part = arena->memory ? arena->memory + arena->used : NULL;
    arena->used = count > SIZE_MAX - arena->used ? SIZE_MAX : arena->used + count;
    return part;
}

static size_t gsf__nn_product(size_t a, size_t b) { return b != 0 && a > SIZE_MAX / b ? SIZE_MAX : a * b; }
static size_t gsf__nn_larger(size_t a, size_t b) { return a > b ? a : b; }

// Shows the tap `count` samples of (rows, columns), numbered from `first`; name: the run's label and a printf format.
GSF_PRINTF(7, 8)
static void gsf__nn_reveal(const gsf__nn_run* run, const float* data, int64_t first, int64_t count, int64_t rows,
                           int64_t columns, const char* format, ...) {
    char name[96];
    va_list args;
    if (!run->tap || !data) return;
    const size_t size = (size_t)snprintf(name, sizeof name, "%s", run->label);
    va_start(args, format);
    vsnprintf(name + size, sizeof name - size, format, args);
    va_end(args);
    for (int64_t i = 0; i < count; i++)
        run->tap->fn(run->tap->user, name, (int32_t)(first + i), data + i * rows * columns, rows, columns);
}

// Fails on a value that is not finite; the message names the tensor below `prefix` that caused it, or else the stage.
static gsf_result gsf__nn_check(const gsf__nn_run* run, const char* stage, const char* prefix, const float* x,
                                int64_t count) {
    return gsf__nn_check_finite(run->ctx, run->weights, run->name, prefix, stage, x, count);
}

// Runs after block `index` of the blocks called `names`: finite check, progress, cancellation.
static gsf_result gsf__nn_end_block(gsf__nn_run* run, const char* names, int64_t index, const float* x, int64_t count) {
    char prefix[96];
    snprintf(prefix, sizeof prefix, "%s%lld.", names, (long long)index);
    GSF__TRY(gsf__nn_check(run, prefix, prefix, x, count));
    gsf__progress(run->ctx, run->stage, ++run->done, run->steps);
    return gsf__check_cancel(run->ctx);
}

// ---- layers: steps of a forward pass

typedef struct gsf__nn_vectors { const float *weight, *bias; } gsf__nn_vectors;

// Converts a small tensor to float32; valid until the vectors of another layer are converted. NULL gives NULL.
static const float* gsf__nn_widen(gsf__nn_run* run, const gsf_nn_tensor* tensor, size_t at) {
    if (!tensor) return NULL;
    GSF_ASSERT(at + (size_t)tensor->count <= run->vectors_size);
    gsf_nn_convert_tensor(tensor, 0, tensor->count, run->vectors + at);
    return run->vectors + at;
}

static gsf__nn_vectors gsf__nn_widen_layer(gsf__nn_run* run, const gsf__nn_layer* layer) {
    gsf__nn_vectors v;
    v.weight = gsf__nn_widen(run, layer->weight, 0);
    v.bias = gsf__nn_widen(run, layer->bias, layer->bias ? (size_t)layer->bias->count : 0);
    return v;
}

// Every linear layer of a network is computed here, in int8, bfloat16 or float32.
static gsf_result gsf__nn_apply(gsf__nn_run* run, const gsf__nn_layer* layer, gsf__nn_linear_desc* d) {
    const gsf__nn_quantized* q = run->quantized ? run->quantized + (layer->weight - run->weights->tensors) : NULL;
    d->weight = layer->weight;
    d->bias = layer->bias;
    d->bf16 = run->bf16;
    return q && q->data ? gsf__nn_run_linear_int8(run->ctx, &run->workspace, d, q)
                        : gsf__nn_run_linear(run->ctx, &run->workspace, d);
}

// y = activation(x w^T + b); rows of y are ldy floats apart (0: dense)
static gsf_result gsf__nn_linear(gsf__nn_run* run, const gsf__nn_layer* layer, gsf__nn_activation activation,
                                 const float* x, int64_t rows, float* y, int64_t ldy) {
    gsf__nn_linear_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.rows = rows;
    d.activation = activation;
    d.y = y;
    d.ldy = ldy;
    return gsf__nn_apply(run, layer, &d);
}

// y += gate * (x w^T + b); gate NULL: 1.
static gsf_result gsf__nn_add(gsf__nn_run* run, const gsf__nn_layer* layer, const float* gate, const float* x, int64_t rows,
                              float* y) {
    gsf__nn_linear_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.rows = rows;
    d.gate = gate;
    d.accumulate = 1;
    d.y = y;
    return gsf__nn_apply(run, layer, &d);
}

// LayerNorm over (rows, the layer's width); y may equal x.
static void gsf__nn_norm(gsf__nn_run* run, const gsf__nn_layer* layer, float eps, const float* x, int64_t rows, float* y) {
    const gsf__nn_vectors v = gsf__nn_widen_layer(run, layer);
    gsf__nn_layer_norm(run->ctx, x, rows, layer->weight->count, v.weight, v.bias, eps, y);
}

// LayerNorm of each head of q or k, then RoPE (gsf__nn_head_norm_rope); does nothing if the network has no such norm.
static void gsf__nn_norm_heads(gsf__nn_run* run, const gsf__nn_layer* layer, float eps, int32_t heads, int32_t head_dim,
                               const float* cosine, const float* sine, int64_t rope_first, float* x, int64_t rows,
                               int64_t ldx) {
    if (!layer->weight) return;
    const gsf__nn_vectors v = gsf__nn_widen_layer(run, layer);
    gsf__nn_head_norm_rope(run->ctx, x, rows, ldx, heads, head_dim, v.weight, v.bias, eps, cosine, sine, rope_first);
}

// Attention within each of `samples` samples, which are stored one after another in q, k, v and out.
static gsf_result gsf__nn_attend(gsf__nn_run* run, const gsf__nn_attention_desc* desc, int64_t samples) {
    gsf__nn_attention_desc d = *desc;
    const int64_t width = (int64_t)d.heads * d.head_dim;
    d.bf16 = run->bf16;
    for (int64_t i = 0; i < samples; i++) {
        GSF__TRY(gsf__nn_run_attention(run->ctx, &run->workspace, &d));
        d.q += d.queries * (d.ldq ? d.ldq : width);
        d.k += d.keys * (d.ldk ? d.ldk : width);
        d.v += d.keys * (d.ldv ? d.ldv : width);
        d.out += d.queries * (d.ldo ? d.ldo : width);
    }
    return GSF_OK;
}

// ---- layers: patches

// images (channels, height, width) and rows (channels, patch, patch) of their patches
typedef struct gsf__nn_patch_job {
    const float* from;
    float* to;
    int64_t channels, height, width, patch;
    int back;                      // from rows to images
    const float *mean, *deviation; // of each channel, for normalization; NULL: none
} gsf__nn_patch_job;

static void gsf__nn_patch_row(void* arg, size_t index, int32_t worker) { // one row of patches
    const gsf__nn_patch_job* job = (const gsf__nn_patch_job*)arg;
    const int64_t p = job->patch, across = job->width / p, down = job->height / p, row = (int64_t)index;
    const int64_t plane = job->height * job->width, image = row / down * job->channels * plane;
    int64_t at = row * across * job->channels * p * p; // offset in the rows
    (void)worker;
    for (int64_t column = 0; column < across; column++)
        for (int64_t c = 0; c < job->channels; c++) {
            const int64_t corner = image + c * plane + row % down * p * job->width + column * p;
            const float mean = job->mean ? job->mean[c] : 0.0f, deviation = job->mean ? job->deviation[c] : 1.0f;
            for (int64_t y = 0; y < p; y++, at += p)
                for (int64_t x = 0; x < p; x++) {
                    const int64_t pixel = corner + y * job->width + x;
                    if (job->back) job->to[pixel] = job->from[at + x];
                    else job->to[at + x] = (job->from[pixel] - mean) / deviation;
                }
        }
}

static void gsf__nn_patch(gsf_context* ctx, const gsf__nn_patch_job* job, int64_t images) {
    gsf__parallel_for(ctx, (size_t)(images * (job->height / job->patch)), gsf__nn_patch_row, (void*)(uintptr_t)job);
}

// ---- layers: 2D RoPE

#define GSF__KERNELS "gsfixer_nn.h"
#define GSF__KERNELS_TURN
#include "gsfixer.h" // compiles the code below once per instruction set
#undef GSF__KERNELS_TURN

#endif // GSF__ISA
#ifdef GSF__KERNELS_TURN

// Rotates the pairs (x[i], x[i + count]) by the angles given by cos and sin (count).
GSF__V_KERNEL void GSF__V(gsf__nn_turn)(float* x, int64_t count, const float* cos, const float* sin) {
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t n = (size_t)(count - i);
        const gsf__vf a = gsf__v_load_first(x + i, n), b = gsf__v_load_first(x + i + count, n);
        const gsf__vf c = gsf__v_load_first(cos + i, n), s = gsf__v_load_first(sin + i, n);
        gsf__v_store_first(x + i, gsf__v_msub(a, c, b * s), n);
        gsf__v_store_first(x + i + count, gsf__v_madd(b, c, a * s), n);
    }
}

#endif // GSF__KERNELS_TURN
#ifndef GSF__ISA

typedef void (*gsf__nn_turn_fn)(float* x, int64_t count, const float* cos, const float* sin);

static gsf__nn_turn_fn gsf__nn_turn_of(gsf_cpu_level level) {
#if GSF__X86
    if (level >= GSF_CPU_AVX2) return gsf__nn_turn_avx2;
#endif
    (void)level;
    return gsf__nn_turn_scalar;
}

enum { GSF__NN_TURN_ROWS = 32 }; // per chunk

typedef struct gsf__nn_turn_job {
    const gsf__nn_run* run;
    gsf__nn_turn_fn turn;
    float* x;       // rows of `stride` floats that start with q | k
    int64_t rows, stride;
} gsf__nn_turn_job;

// Rotates the first half of every head by the patch's row, counted from 1, and the second half by its column. Tokens
// without a position count as position 0, whose rotation is the identity.
static void gsf__nn_turn_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__nn_turn_job* job = (const gsf__nn_turn_job*)arg;
    const gsf__nn_run* run = job->run;
    const int64_t dim = run->sizes->head_dim, quarter = dim / 4, heads = 2 * (int64_t)run->sizes->heads; // of q and k
    const int64_t begin = (int64_t)chunk * GSF__NN_TURN_ROWS, end = gsf__least(begin + GSF__NN_TURN_ROWS, job->rows);
    (void)worker;
    for (int64_t r = begin; r < end; r++) {
        const int64_t at = r % run->image_tokens - run->special;
        if (at < 0) continue;
        const int64_t row = at / run->across * quarter, column = at % run->across * quarter;
        for (int64_t h = 0; h < heads; h++) {
            float* x = job->x + r * job->stride + h * dim;
            job->turn(x, quarter, run->cos + row, run->sin + row);
            job->turn(x + dim / 2, quarter, run->cos + column, run->sin + column);
        }
    }
}

// ---- layers: blocks

typedef struct gsf__nn_block { // x += scale1 * out(attention(norm1(x))); x += scale2 * down(hidden(norm2(x)))
    gsf__nn_layer norm1, norm2, qkv, q, k, v; // qkv (3 heads * head_dim, width), or separate q, k, v
    gsf__nn_layer q_norm, k_norm;             // (head_dim)
    gsf__nn_layer out, gate, up, down;        // hidden: activation(up(x)), or activation(gate(x)) * up(x)
    const gsf_nn_tensor *scale1, *scale2;     // LayerScale or NULL
} gsf__nn_block;

static void gsf__nn_norm_block(gsf__nn_run* run, const gsf__nn_layer* norm, const float* x, int64_t rows) {
    const gsf__nn_block_sizes* s = run->sizes;
    if (s->rms) gsf__nn_rms_norm(run->ctx, x, rows, s->width, gsf__nn_widen(run, norm->weight, 0), s->eps, run->normed);
    else gsf__nn_norm(run, norm, s->eps, x, rows, run->normed);
}

// Stores q, k and v of run->normed side by side in run->wide, then normalizes and rotates q and k.
static gsf_result gsf__nn_project_block(gsf__nn_run* run, const gsf__nn_block* b, int64_t rows) {
    const gsf__nn_block_sizes* s = run->sizes;
    const int64_t inner = (int64_t)s->heads * s->head_dim, ld = 3 * inner;
    float* q = run->wide;
    if (b->qkv.weight) {
        GSF__TRY(gsf__nn_linear(run, &b->qkv, GSF__NN_LINEAR, run->normed, rows, q, ld));
    } else {
        GSF__TRY(gsf__nn_linear(run, &b->q, GSF__NN_LINEAR, run->normed, rows, q, ld));
        GSF__TRY(gsf__nn_linear(run, &b->k, GSF__NN_LINEAR, run->normed, rows, q + inner, ld));
        GSF__TRY(gsf__nn_linear(run, &b->v, GSF__NN_LINEAR, run->normed, rows, q + 2 * inner, ld));
    }
    gsf__nn_norm_heads(run, &b->q_norm, s->head_eps, s->heads, s->head_dim, NULL, NULL, 0, q, rows, ld);
    gsf__nn_norm_heads(run, &b->k_norm, s->head_eps, s->heads, s->head_dim, NULL, NULL, 0, q + inner, rows, ld);
    if (!run->cos) return GSF_OK;
    gsf__nn_turn_job job = {run, gsf__nn_turn_of(run->ctx->cpu_level), q, rows, ld};
    gsf__parallel_for(run->ctx, gsf__nn_chunks(rows, GSF__NN_TURN_ROWS), gsf__nn_turn_chunk, &job);
    return GSF_OK;
}

// Appends the new tokens' keys and values to the cache of layer `index` and makes the attention read the cache.
static void gsf__nn_look_back(gsf__nn_run* run, int64_t index, int64_t rows, gsf__nn_attention_desc* a) {
    const gsf__nn_cache* cache = run->cache;
    const int64_t inner = (int64_t)a->heads * a->head_dim, first = index * cache->capacity * inner;
    for (int64_t r = 0; r < rows; r++) {
        const int64_t to = first + (cache->past + r) * inner;
        memcpy(cache->keys + to, a->k + r * a->ldk, (size_t)inner * sizeof(float));
        memcpy(cache->values + to, a->v + r * a->ldv, (size_t)inner * sizeof(float));
    }
    a->keys = cache->past + rows;
    a->k = cache->keys + first;
    a->v = cache->values + first;
    a->ldk = a->ldv = inner;
    a->mask = rows > 1 ? cache->mask : NULL;
}

typedef struct gsf__nn_product_job {
    float* a;
    const float* b;
    int64_t count;
} gsf__nn_product_job;

static void gsf__nn_multiply_chunk(void* arg, size_t chunk, int32_t worker) { // a *= b
    const gsf__nn_product_job* job = (const gsf__nn_product_job*)arg;
    const int64_t begin = (int64_t)chunk * GSF__NN_CHUNK, end = gsf__least(begin + GSF__NN_CHUNK, job->count);
    (void)worker;
    for (int64_t i = begin; i < end; i++) job->a[i] *= job->b[i];
}

// x += scale * down(hidden(run->normed)), in groups of rows whose hidden layer fits in run->wide.
static gsf_result gsf__nn_feed_forward(gsf__nn_run* run, const gsf__nn_block* b, const float* scale, float* x,
                                       int64_t rows) {
    const gsf__nn_block_sizes* s = run->sizes;
    const int64_t runs = gsf__ceil_div(rows, run->wide_count / (s->mlp * (1 + s->gated))), most = gsf__ceil_div(rows, runs);
    for (int64_t r = 0; r < rows; r += most) {
        const int64_t n = gsf__least(rows - r, most);
        const float* from = run->normed + r * s->width;
        GSF__TRY(gsf__nn_linear(run, s->gated ? &b->gate : &b->up, s->activation, from, n, run->wide, 0));
        if (s->gated) {
            gsf__nn_product_job job = {run->wide, run->wide + n * s->mlp, n * s->mlp};
            GSF__TRY(gsf__nn_linear(run, &b->up, GSF__NN_LINEAR, from, n, run->wide + n * s->mlp, 0));
            gsf__parallel_for(run->ctx, gsf__nn_chunks(job.count, GSF__NN_CHUNK), gsf__nn_multiply_chunk, &job);
        }
        GSF__TRY(gsf__nn_add(run, &b->down, scale, run->wide, n, x + r * s->width));
    }
    return GSF_OK;
}

// Block `index` of a network on x (samples, tokens, width), in place; tokens attend within their sample.
static gsf_result gsf__nn_block_forward(gsf__nn_run* run, const gsf__nn_block* b, int64_t index, float* x, int64_t samples,
                                        int64_t tokens) {
    const gsf__nn_block_sizes* s = run->sizes;
    const int64_t inner = (int64_t)s->heads * s->head_dim, rows = samples * tokens;
    gsf__nn_attention_desc a;
    gsf__nn_norm_block(run, &b->norm1, x, rows);
    if (run->label[0]) gsf__nn_reveal(run, run->normed, 0, samples, tokens, s->width, "attn_norm");
    GSF__TRY(gsf__nn_project_block(run, b, rows));
    memset(&a, 0, sizeof a);
    a.queries = a.keys = tokens;
    a.heads = s->heads;
    a.head_dim = s->head_dim;
    a.q = run->wide;
    a.k = a.q + inner;
    a.v = a.k + inner;
    a.ldq = a.ldk = a.ldv = 3 * inner;
    a.bias = run->bias;
    a.scale = run->scale;
    a.out = run->normed;
    if (run->cache) gsf__nn_look_back(run, index, rows, &a);
    GSF__TRY(gsf__nn_attend(run, &a, samples));
    GSF__TRY(gsf__nn_add(run, &b->out, gsf__nn_widen(run, b->scale1, 0), run->normed, rows, x));
    if (run->label[0]) gsf__nn_reveal(run, x, 0, samples, tokens, s->width, "after_attn");
    GSF__TRY(gsf__check_cancel(run->ctx));
    gsf__nn_norm_block(run, &b->norm2, x, rows);
    return gsf__nn_feed_forward(run, b, gsf__nn_widen(run, b->scale2, 0), x, rows);
}

// Table entries of a block, whose names differ between files. Letters: d width, m MLP, i heads * head_dim, t 3 * i,
// h head_dim, b 0 if q, k, v have no biases, n 0 if q and k have no norms.
#define GSF__NN_BLOCK(member) GSF__NN_AT(gsf__nn_block, member)
#define GSF__NN_BLOCK_AS(member, form, option) offsetof(gsf__nn_block, member), form, option

static gsf__nn_sizes gsf__nn_sizes_of_block(const gsf__nn_block_sizes* s) {
    const int64_t inner = (int64_t)s->heads * s->head_dim;
    const gsf__nn_sizes sizes = {{{'d', s->width}, {'m', s->mlp}, {'i', inner}, {'t', 3 * inner}, {'h', s->head_dim},
                                  {'b', s->qkv_bias}, {'n', s->head_norm}}};
    return sizes;
}

// Allocates and binds `count` blocks called NAMES0., NAMES1., ...; the caller frees *out, also on error.
static gsf_result gsf__nn_bind_blocks(gsf__nn_loader* loader, const gsf__nn_block_sizes* s, const gsf__nn_entry* entries,
                                      const char* names, int64_t count, gsf__nn_block** out) {
    const gsf__nn_sizes sizes = gsf__nn_sizes_of_block(s);
    *out = (gsf__nn_block*)gsf_alloc_zeroed(loader->ctx, (size_t)count, sizeof **out);
    if (!*out) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf__nn_bind_each(loader, &sizes, entries, names, count, sizeof **out, *out);
}

// Floats that run->wide needs for `rows` rows if the MLP processes at most `most` rows at a time.
static size_t gsf__nn_wide(const gsf__nn_block_sizes* s, int64_t rows, int64_t most) {
    const size_t inner = (size_t)s->heads * (size_t)s->head_dim;
    const size_t hidden = gsf__nn_product((size_t)gsf__least(rows, most), (size_t)(s->mlp * (1 + s->gated)));
    return gsf__nn_larger(hidden, gsf__nn_product(3 * (size_t)rows, inner));
}

static double gsf__nn_block_flops(const gsf__nn_block_sizes* s, double samples, double tokens) {
    const double inner = (double)s->heads * s->head_dim, rows = samples * tokens;
    return 2.0 * rows * (double)s->width * (4.0 * inner + (2.0 + s->gated) * (double)s->mlp) +
           4.0 * rows * tokens * inner;
}
// ---- >>nn image encoders --------------------------------------------------------
//
// DINOv2 with registers (Oquab et al. 2023; Darcet et al. 2023) and the aggregator of VGGT (Wang et al. 2025): a DINOv2
// embeds each image, then blocks that attend within each image alternate with blocks that attend across all images.
// Both are vision transformers built of gsf__nn_block. The details follow transformers 4.51.3
// (modeling_dinov2_with_registers.py) and VGGT's aggregator.py, block.py, attention.py and rope.py.

typedef struct gsf__vit { // pixels to tokens: a DINOv2
    gsf__nn_block_sizes sizes;
    int64_t channels, patch, registers, grid, layers;
    const char *block_names, *prefix; // tensor names of the blocks; of the embeddings
    const gsf_nn_tensor *class_token, *register_tokens, *positions;
    gsf__nn_layer patches, norm;
    gsf__nn_layer pre_norm;        // CLIP: before the blocks
    const float *mean, *deviation; // of each channel of the pixels, for normalization; NULL: none
    gsf__nn_block* blocks;
} gsf__vit;

typedef struct gsf__vggt {
    gsf__vit embed;
    gsf__nn_block_sizes sizes; // of frame and global blocks
    int64_t registers, layers;
    double rope_base;          // 0: no rotation
    gsf__nn_block *frame, *global; // (layers)
    const gsf_nn_tensor *camera_token, *register_token; // (1, 2, count, width): of the first image, of all others
} gsf__vggt;

// ---- image encoders: tables of tensors

// Letters in addition to those of a block: c channels, p patch, r registers, s positions.
#define GSF__VIT_COMMON                                 \
    {"norm1", "d", GSF__NN_BLOCK(norm1)},               \
    {"norm2", "d", GSF__NN_BLOCK(norm2)},               \
    {"mlp.fc1", "md", GSF__NN_BLOCK(up)},               \
    {"mlp.fc2", "dm", GSF__NN_BLOCK(down)}

static const gsf__nn_entry gsf__dinov2_block_entries[] = { // below encoder.layer.N.
    GSF__VIT_COMMON,
    {"attention.attention.query", "dd", GSF__NN_BLOCK_AS(q, GSF__NN_BIASED, 'b')},
    {"attention.attention.key", "dd", GSF__NN_BLOCK_AS(k, GSF__NN_BIASED, 'b')},
    {"attention.attention.value", "dd", GSF__NN_BLOCK_AS(v, GSF__NN_BIASED, 'b')},
    {"attention.output.dense", "dd", GSF__NN_BLOCK(out)},
    {"layer_scale1.lambda1", "d", GSF__NN_BLOCK_AS(scale1, GSF__NN_TENSOR, 0)},
    {"layer_scale2.lambda1", "d", GSF__NN_BLOCK_AS(scale2, GSF__NN_TENSOR, 0)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__vggt_block_entries[] = { // below aggregator.patch_embed.blocks.N. and the like
    GSF__VIT_COMMON,
    {"attn.qkv", "td", GSF__NN_BLOCK_AS(qkv, GSF__NN_BIASED, 'b')},
    {"attn.q_norm", "h", GSF__NN_BLOCK_AS(q_norm, GSF__NN_PAIR, 'n')},
    {"attn.k_norm", "h", GSF__NN_BLOCK_AS(k_norm, GSF__NN_PAIR, 'n')},
    {"attn.proj", "dd", GSF__NN_BLOCK(out)},
    {"ls1.gamma", "d", GSF__NN_BLOCK_AS(scale1, GSF__NN_TENSOR, 0)},
    {"ls2.gamma", "d", GSF__NN_BLOCK_AS(scale2, GSF__NN_TENSOR, 0)},
    GSF__NN_END,
};
#undef GSF__VIT_COMMON

#define GSF__VIT_TENSOR(member) offsetof(gsf__vit, member), GSF__NN_TENSOR, 0
static const gsf__nn_entry gsf__dinov2_entries[] = {
    {"embeddings.cls_token", "11d", GSF__VIT_TENSOR(class_token)},
    {"embeddings.register_tokens", "1rd", GSF__VIT_TENSOR(register_tokens)},
    {"embeddings.position_embeddings", "1sd", GSF__VIT_TENSOR(positions)},
    {"embeddings.patch_embeddings.projection", "dcpp", GSF__NN_AT(gsf__vit, patches)},
    {"layernorm", "d", GSF__NN_AT(gsf__vit, norm)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__vggt_embed_entries[] = {
    {"aggregator.patch_embed.cls_token", "11d", GSF__VIT_TENSOR(class_token)},
    {"aggregator.patch_embed.register_tokens", "1rd", GSF__VIT_TENSOR(register_tokens)},
    {"aggregator.patch_embed.pos_embed", "1sd", GSF__VIT_TENSOR(positions)},
    {"aggregator.patch_embed.patch_embed.proj", "dcpp", GSF__NN_AT(gsf__vit, patches)},
    {"aggregator.patch_embed.norm", "d", GSF__NN_AT(gsf__vit, norm)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__vggt_entries[] = {
    {"aggregator.camera_token", "121d", offsetof(gsf__vggt, camera_token), GSF__NN_TENSOR, 0},
    {"aggregator.register_token", "12rd", offsetof(gsf__vggt, register_token), GSF__NN_TENSOR, 0},
    GSF__NN_END,
};

static gsf__nn_sizes gsf__vit_sizes(const gsf__vit* vit) {
    const gsf__nn_sizes sizes = {{{'d', vit->sizes.width}, {'c', vit->channels}, {'p', vit->patch}, {'r', vit->registers},
                                  {'s', vit->grid * vit->grid + 1}}};
    return sizes;
}

static gsf__nn_sizes gsf__vggt_sizes(const gsf__vggt* net) {
    const gsf__nn_sizes sizes = {{{'d', net->sizes.width}, {'r', net->registers}, {'2', 2}}};
    return sizes;
}

// Binds the tensors below `prefix` and the blocks of a vision transformer.
static gsf_result gsf__vit_bind(gsf__nn_loader* loader, const gsf__nn_entry* entries, const gsf__nn_entry* block_entries,
                                const char* prefix, gsf__vit* vit) {
    const gsf__nn_sizes sizes = gsf__vit_sizes(vit);
    GSF__TRY(gsf__nn_bind(loader, &sizes, entries, prefix, vit));
    return gsf__nn_bind_blocks(loader, &vit->sizes, block_entries, vit->block_names, vit->layers, &vit->blocks);
}

// ---- image encoders: from pixels to tokens

// Position embeddings of the class token and of (down, across) patches, interpolated from the square grid of the file:
// out (1 + patches, width). PyTorch's resampling (bicubic, antialias, align_corners=False) has the same weights as
// Pillow's.
static gsf_result gsf__vit_positions(gsf_context* ctx, const gsf__vit* vit, int64_t down, int64_t across, float* out) {
    const int64_t d = vit->sizes.width, grid = vit->grid;
    if (down == grid && across == grid) {
        gsf_nn_convert_tensor(vit->positions, 0, vit->positions->count, out);
        return GSF_OK;
    }
    float* square = (float*)gsf_alloc(ctx, (size_t)(grid * grid * d), sizeof(float));
    if (!square) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_nn_convert_tensor(vit->positions, 0, d, out);
    gsf_nn_convert_tensor(vit->positions, d, grid * grid * d, square);
    const gsf_image from = gsf_wrap_image(square, GSF_F32, grid, grid, (int32_t)d);
    const gsf_image to = gsf_wrap_image(out + d, GSF_F32, across, down, (int32_t)d);
    const gsf_result result = gsf_resize_image(ctx, &from, GSF_RESIZE_PIL_BICUBIC, &to);
    gsf_free(ctx, square);
    return result;
}

static const float gsf__imagenet_mean[3] = {0.485f, 0.456f, 0.406f}, gsf__imagenet_deviation[3] = {0.229f, 0.224f, 0.225f};

// Tokens of one image before the blocks: class, registers, patches.
static gsf_result gsf__vit_embed(gsf__nn_run* run, const gsf__vit* vit, const gsf_nn_encoder_desc* in, int64_t image,
                                 const float* positions, float* x) {
    const int64_t d = vit->sizes.width, p = vit->patch, down = in->height / p, across = in->width / p;
    const int64_t tokens = 1 + vit->registers + down * across;
    float* patches = x + (1 + vit->registers) * d;
    gsf__nn_patch_job job = {in->pixels + image * vit->channels * in->height * in->width, run->wide, vit->channels,
                             in->height, in->width, p, 0, vit->mean, vit->deviation};
    gsf__nn_patch(run->ctx, &job, 1);
    gsf_nn_convert_tensor(vit->class_token, 0, d, x);
    for (int64_t i = 0; i < d; i++) x[i] += positions[i];
    gsf_nn_convert_tensor(vit->register_tokens, 0, vit->registers * d, x + d);
    memcpy(patches, positions + d, (size_t)(down * across * d) * sizeof(float));
    GSF__TRY(gsf__nn_add(run, &vit->patches, NULL, run->wide, down * across, patches));
    if (vit->pre_norm.weight) gsf__nn_norm(run, &vit->pre_norm, vit->sizes.eps, x, tokens, x);
    gsf__nn_reveal(run, x, image, 1, tokens, d, "embeddings");
    return gsf__nn_check(run, vit->prefix, vit->prefix, x, tokens * d);
}

// Embeds `count` images from `first` on and runs the blocks: x (count, tokens, width), before the final norm.
static gsf_result gsf__vit_forward(gsf__nn_run* run, const gsf__vit* vit, const gsf_nn_encoder_desc* in, int64_t first,
                                   int64_t count, const float* positions, float* x) {
    const int64_t d = vit->sizes.width;
    const int64_t tokens = 1 + vit->registers + in->height / vit->patch * (in->width / vit->patch);
    run->sizes = &vit->sizes;
    for (int64_t i = 0; i < count; i++)
        GSF__TRY(gsf__vit_embed(run, vit, in, first + i, positions, x + i * tokens * d));
    for (int64_t layer = 0; layer < vit->layers; layer++) {
        GSF__TRY(gsf__nn_block_forward(run, &vit->blocks[layer], layer, x, count, tokens));
        GSF__TRY(gsf__nn_end_block(run, vit->block_names, layer, x, count * tokens * d));
        gsf__nn_reveal(run, x, first, count, tokens, d, "layer%lld", (long long)layer);
    }
    return GSF_OK;
}

// ---- image encoders: memory

enum { GSF__VIT_GROUP_ROWS = 4096, GSF__VIT_MLP_ROWS = 2048 }; // tokens of a group of images; hidden rows of the MLP

typedef struct gsf__vit_plan {
    int64_t patches, tokens, group;        // per image; tokens per image in the DINOv2; images per group
    float *positions, *x, *stream, *turns; // stream, turns: the aggregator's tokens and its RoPE tables
    size_t turn_count;                     // number of cosines, and of sines
    size_t floats, square;                 // of the whole layout; temporary, while positions are interpolated
} gsf__vit_plan;

// Divides `memory` into buffers; NULL: only counts the floats needed. net: the aggregator around the DINOv2, or NULL.
static gsf__vit_plan gsf__vit_lay_out(gsf__nn_run* run, const gsf__vit* vit, const gsf__vggt* net,
                                      const gsf_nn_encoder_desc* in, float* memory) {
    const size_t d = (size_t)vit->sizes.width, longer = (size_t)(in->height > in->width ? in->height : in->width);
    gsf__nn_arena arena = {memory, 0};
    gsf__vit_plan p;
    memset(&p, 0, sizeof p);
    p.patches = in->height / vit->patch * (in->width / vit->patch);
    p.tokens = 1 + vit->registers + p.patches;
    p.group = gsf__least(in->images, p.tokens < GSF__VIT_GROUP_ROWS ? GSF__VIT_GROUP_ROWS / p.tokens : 1);
    const int64_t rows = p.group * p.tokens, rows2 = net ? in->images * (1 + net->registers + p.patches) : 0;
    const size_t x = gsf__nn_product((size_t)rows, d), stream = gsf__nn_product((size_t)rows2, d);
    size_t wide = gsf__nn_larger(gsf__nn_wide(&vit->sizes, rows, GSF__VIT_MLP_ROWS),
                                 (size_t)p.patches * (size_t)(vit->channels * vit->patch * vit->patch));
    if (net) wide = gsf__nn_larger(wide, gsf__nn_wide(&net->sizes, rows2, GSF__VIT_MLP_ROWS));
    if (net && net->rope_base > 0.0) p.turn_count = longer / (size_t)vit->patch * (size_t)(net->sizes.head_dim / 4);
    if (in->height / vit->patch != vit->grid || in->width / vit->patch != vit->grid)
        p.square = (size_t)(vit->grid * (vit->grid + in->width / vit->patch)) * d;
    run->vectors_size = 2 * d;
    run->wide_count = (int64_t)wide;
    p.positions = gsf__nn_share(&arena, gsf__nn_product((size_t)p.patches + 1, d));
    p.x = gsf__nn_share(&arena, x);
    run->normed = gsf__nn_share(&arena, gsf__nn_larger(x, stream));
    run->wide = gsf__nn_share(&arena, wide);
    run->vectors = gsf__nn_share(&arena, run->vectors_size);
    p.stream = gsf__nn_share(&arena, stream);
    p.turns = gsf__nn_share(&arena, 2 * p.turn_count);
    p.floats = arena.used;
    return p;
}

// Allocates and divides the memory of a run and interpolates the positions; the caller frees *memory, also on error.
static gsf_result gsf__vit_open_run(gsf__nn_run* run, const gsf__vit* vit, const gsf__vggt* net,
                                    const gsf_nn_encoder_desc* in, gsf__vit_plan* plan, float** memory) {
    *memory = (float*)gsf_alloc(run->ctx, gsf__vit_lay_out(run, vit, net, in, NULL).floats, sizeof(float));
    if (!*memory) return GSF_ERROR_OUT_OF_MEMORY;
    *plan = gsf__vit_lay_out(run, vit, net, in, *memory);
    GSF__TRY(gsf__vit_positions(run->ctx, vit, in->height / vit->patch, in->width / vit->patch, plan->positions));
    gsf__nn_reveal(run, plan->positions, 0, 1, plan->patches + 1, vit->sizes.width, "positions");
    return GSF_OK;
}

static double gsf__vit_bytes(const gsf__vit* vit, const gsf__vggt* net, const gsf_nn_encoder_desc* in) {
    gsf__nn_run run;
    memset(&run, 0, sizeof run);
    const gsf__vit_plan p = gsf__vit_lay_out(&run, vit, net, in, NULL);
    return 4.0 * ((double)p.floats + (double)p.square);
}

static double gsf__vit_flops(const gsf__vit* vit, const gsf_nn_encoder_desc* in) {
    const double patches = (double)(in->height / vit->patch * (in->width / vit->patch));
    const double patch = (double)(vit->channels * vit->patch * vit->patch) * (double)vit->sizes.width;
    const double tokens = 1.0 + (double)vit->registers + patches;
    return in->images * ((double)vit->layers * gsf__nn_block_flops(&vit->sizes, 1.0, tokens) + 2.0 * patches * patch);
}

static gsf_result gsf__vit_check_input(gsf_context* ctx, const char* name, int64_t channels, int64_t patch,
                                       const gsf_nn_encoder_desc* in, const float* out) {
    enum { MOST = 1 << 15 }; // pixels per side
    if (!in->pixels || !out || in->images < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: images are missing", name);
    if (in->height < patch || in->width < patch || in->height % patch || in->width % patch || in->height > MOST ||
        in->width > MOST)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "%s: %d x %d pixels, but sides must be multiples of %lld up to %d",
                        name, (int)in->width, (int)in->height, (long long)patch, MOST);
    const int64_t count = in->images * channels * in->height * in->width;
    const int64_t at = gsf__nn_find_not_finite(ctx, in->pixels, count);
    if (at >= 0)
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: value %lld of %lld of the images is %g", name, (long long)at,
                        (long long)count, (double)in->pixels[at]);
    return GSF_OK;
}

// ---- image encoders: DINOv2

// Missing keys take the defaults of transformers' Dinov2WithRegistersConfig.
static gsf_result gsf__dinov2_read_config(const gsf__nn_config* file, void* network) {
    gsf__vit* vit = (gsf__vit*)network;
    int64_t image;
    double ratio;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT_OR("hidden_size", vit->sizes.width, 768, 1, 65536),
        GSF__KEY_INT_OR("num_attention_heads", vit->sizes.heads, 12, 1, 1024),
        GSF__KEY_INT_OR("num_hidden_layers", vit->layers, 12, 1, 1024),
        GSF__KEY_INT_OR("num_channels", vit->channels, 3, 1, 1024), GSF__KEY_INT_OR("patch_size", vit->patch, 16, 1, 1024),
        GSF__KEY_INT_OR("image_size", image, 224, 1, 1 << 15),
        GSF__KEY_INT_OR("num_register_tokens", vit->registers, 4, 0, 1 << 16),
        GSF__KEY_REAL_OR("mlp_ratio", ratio, 4.0, 1e-3, 1024.0),
        GSF__KEY_REAL_OR("layer_norm_eps", vit->sizes.eps, 1e-6, 1e-12, 1.0),
        GSF__KEY_FLAG_OR("qkv_bias", vit->sizes.qkv_bias, 1), GSF__KEY_FLAG_IS("use_swiglu_ffn", 0, 0),
        GSF__KEY_ACTIVATION_OR("hidden_act", vit->sizes.activation, "gelu")};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    if (vit->sizes.width % vit->sizes.heads || image < vit->patch || (double)vit->sizes.width * ratio < 1.0)
        return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED,
                        "%s: hidden_size %lld is not a multiple of %d heads, or image_size %lld is below patch_size",
                        file->json.name, (long long)vit->sizes.width, (int)vit->sizes.heads, (long long)image);
    vit->sizes.head_dim = (int32_t)(vit->sizes.width / vit->sizes.heads);
    vit->sizes.mlp = (int64_t)((double)vit->sizes.width * ratio);
    vit->grid = image / vit->patch;
    vit->block_names = "encoder.layer.";
    vit->prefix = "embeddings.";
    return GSF_OK;
}

static gsf_result gsf__dinov2_bind(gsf__nn_loader* loader, void* network) {
    gsf__nn_ignore(loader, "embeddings.mask_token"); // used in training only
    return gsf__vit_bind(loader, gsf__dinov2_entries, gsf__dinov2_block_entries, "", (gsf__vit*)network);
}

GSF_API void gsf_nn_destroy_dinov2(gsf_context* ctx, gsf_nn_dinov2* dinov2) {
    gsf__vit* vit = (gsf__vit*)dinov2->nets;
    if (vit) gsf_free(ctx, vit->blocks);
    gsf_free(ctx, vit);
    gsf_nn_destroy_weights(ctx, &dinov2->weights);
    memset(dinov2, 0, sizeof *dinov2);
}

GSF_API gsf_result gsf_nn_load_dinov2(gsf_context* ctx, const char* folder, gsf_nn_dinov2* out) {
    memset(out, 0, sizeof *out);
    gsf__vit* vit = (gsf__vit*)gsf_alloc_zeroed(ctx, 1, sizeof *vit);
    if (!vit) return GSF_ERROR_OUT_OF_MEMORY;
    out->nets = vit;
    const gsf_result result =
        gsf__nn_open_network(ctx, folder, "model", gsf__dinov2_read_config, gsf__dinov2_bind, vit, &out->weights);
    out->width = (int32_t)vit->sizes.width;
    out->heads = vit->sizes.heads;
    out->layers = (int32_t)vit->layers;
    out->mlp_width = (int32_t)vit->sizes.mlp;
    out->channels = (int32_t)vit->channels;
    out->patch = (int32_t)vit->patch;
    out->special = (int32_t)vit->registers + 1;
    out->grid = (int32_t)vit->grid;
    out->norm_eps = (double)vit->sizes.eps;
    if (result) gsf_nn_destroy_dinov2(ctx, out);
    return result;
}

static void gsf__nn_query_dinov2(const gsf_nn_dinov2* dinov2, const gsf_nn_encoder_desc* input, double* bytes,
                                 double* flops) {
    const gsf__vit* vit = (const gsf__vit*)dinov2->nets;
    if (bytes) *bytes = gsf__vit_bytes(vit, NULL, input);
    if (flops) *flops = gsf__vit_flops(vit, input);
}

static gsf_result gsf__dinov2_run(gsf__nn_run* run, const gsf__vit* vit, const gsf_nn_encoder_desc* in,
                                  const gsf__vit_plan* plan, float* out) {
    const int64_t d = vit->sizes.width, skip = in->all_tokens ? 0 : vit->registers + 1, kept = plan->tokens - skip;
    run->steps = (double)(gsf__ceil_div(in->images, plan->group) * vit->layers);
    for (int64_t first = 0; first < in->images; first += plan->group) {
        const int64_t count = gsf__least(in->images - first, plan->group);
        GSF__TRY(gsf__vit_forward(run, vit, in, first, count, plan->positions, plan->x));
        for (int64_t i = 0; i < count; i++) {
            const float* tokens = plan->x + i * plan->tokens * d;
            gsf__nn_norm(run, &vit->norm, vit->sizes.eps, tokens + skip * d, kept, out + (first + i) * kept * d);
            if (!run->tap) continue;
            gsf__nn_norm(run, &vit->norm, vit->sizes.eps, tokens, plan->tokens, run->normed);
            gsf__nn_reveal(run, run->normed, first + i, 1, plan->tokens, d, "last_hidden_state");
        }
    }
    return gsf__nn_check(run, "layernorm.", "layernorm.", out, in->images * kept * d);
}

// ---- image encoders: VGGT's aggregator

static const char gsf__vggt_frame_names[] = "aggregator.frame_blocks.";
static const char gsf__vggt_global_names[] = "aggregator.global_blocks.";

// One more than the highest block number that follows `names` in a tensor's name.
static int64_t gsf__nn_count_blocks(const gsf_nn_weights* weights, const char* names) {
    const size_t size = strlen(names);
    int64_t count = 0;
    for (size_t i = 0; i < weights->tensor_count; i++) {
        const char* p = weights->tensors[i].name;
        int64_t number = 0;
        if (strncmp(p, names, size) != 0) continue;
        for (p += size; *p >= '0' && *p <= '9' && number < 1 << 20; p++) number = 10 * number + (*p - '0');
        if (*p == '.' && number >= count) count = number + 1;
    }
    return count;
}

// Sizes from the shapes of a few tensors. config.json may override them; binding then checks every tensor against them.
static gsf_result gsf__vggt_read_shapes(gsf__nn_loader* loader, gsf__vggt* net) {
    const gsf_nn_weights* w = loader->weights;
    const int64_t any[4] = {-1, -1, -1, -1};
    const gsf_nn_tensor *patch, *positions, *up, *registers, *embed_up, *embed_registers;
    gsf__vit* vit = &net->embed;
    GSF__TRY(gsf__nn_need(loader, &patch, 4, any, "aggregator.patch_embed.patch_embed.proj.weight"));
    GSF__TRY(gsf__nn_need(loader, &positions, 3, any, "aggregator.patch_embed.pos_embed"));
    GSF__TRY(gsf__nn_need(loader, &embed_registers, 3, any, "aggregator.patch_embed.register_tokens"));
    GSF__TRY(gsf__nn_need(loader, &embed_up, 2, any, "aggregator.patch_embed.blocks.0.mlp.fc1.weight"));
    GSF__TRY(gsf__nn_need(loader, &up, 2, any, "aggregator.frame_blocks.0.mlp.fc1.weight"));
    GSF__TRY(gsf__nn_need(loader, &registers, 4, any, "aggregator.register_token"));
    if (patch->count < 1 || patch->shape[2] > 1024)
        return gsf_fail(loader->ctx, GSF_ERROR_UNSUPPORTED, "%s: a patch of %lld x %lld", w->name,
                        (long long)patch->shape[2], (long long)patch->shape[3]);
    net->sizes.width = vit->sizes.width = patch->shape[0];
    net->sizes.mlp = up->shape[0];
    net->registers = registers->shape[2];
    net->layers = gsf__nn_count_blocks(w, gsf__vggt_frame_names);
    vit->sizes.mlp = embed_up->shape[0];
    vit->channels = patch->shape[1];
    vit->patch = patch->shape[2];
    vit->registers = embed_registers->shape[1];
    vit->layers = gsf__nn_count_blocks(w, "aggregator.patch_embed.blocks.");
    vit->block_names = "aggregator.patch_embed.blocks.";
    vit->prefix = "aggregator.patch_embed.";
    vit->mean = gsf__imagenet_mean;
    vit->deviation = gsf__imagenet_deviation;
    while (vit->grid < 1 << 15 && (vit->grid + 1) * (vit->grid + 1) < positions->shape[1]) vit->grid++;
    vit->sizes.activation = net->sizes.activation = GSF__NN_GELU;
    vit->sizes.qkv_bias = net->sizes.qkv_bias = 1;
    vit->sizes.eps = 1e-6f;
    net->sizes.eps = net->sizes.head_eps = 1e-5f;
    const gsf_nn_tensor* norm = gsf_nn_find_tensor(w, "aggregator.frame_blocks.0.attn.q_norm.weight");
    const int64_t dim = norm && norm->count > 0 ? norm->count : 64;
    net->sizes.head_norm = norm != NULL;
    net->sizes.heads = net->sizes.width / dim < 1024 ? (int32_t)(net->sizes.width / dim) : 0;
    return GSF_OK;
}

// Keys of config.json override the sizes read from the tensors; missing keys leave them unchanged.
static gsf_result gsf__vggt_read_config(const gsf__nn_config* file, gsf__vggt* net) {
    gsf__vit* vit = &net->embed;
    gsf__nn_block_sizes* s = &net->sizes;
    int64_t image = vit->grid * vit->patch, count = 0;
    double ratio;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT_OR("embed_dim", s->width, (double)s->width, 1, 1 << 16),
        GSF__KEY_INT_OR("patch_size", vit->patch, (double)vit->patch, 1, 1 << 16),
        GSF__KEY_INT_OR("img_size", image, (double)image, 1, 1 << 16),
        GSF__KEY_INT_OR("depth", net->layers, (double)net->layers, 1, 1 << 16),
        GSF__KEY_INT_OR("num_register_tokens", net->registers, (double)net->registers, 0, 1 << 16),
        GSF__KEY_INT_OR("num_heads", s->heads, (double)s->heads, 1, 1 << 16),
        GSF__KEY_REAL_OR("mlp_ratio", ratio, 0.0, 0.0, 1024.0),
        GSF__KEY_REAL_OR("rope_freq", net->rope_base, net->rope_base, -1e9, 1e9),
        GSF__KEY_FLAG_OR("qk_norm", s->head_norm, (double)s->head_norm)};
    int64_t given;
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    if (ratio > 0.0) s->mlp = (int64_t)((double)s->width * ratio);
    if (gsf__nn_config_find(file, "num_register_tokens")) vit->registers = net->registers;
    vit->sizes.width = s->width;
    vit->grid = image / vit->patch;
    GSF__TRY(gsf__nn_config_int_or(file, "aa_block_size", 1, 1, 1 << 20, &given));
    const gsf_json_value* order = gsf__nn_config_find(file, "aa_order");
    int ok = given == 1 && (!order || (order->type == GSF_JSON_ARRAY && order->count == 2));
    for (uint32_t i = ok && order ? order->child : 0; i; i = file->json.values[i].next, count++) {
        const gsf_json_value* v = &file->json.values[i];
        ok = ok && v->type == GSF_JSON_STRING && strcmp(v->string, count ? "global" : "frame") == 0;
    }
    if (!ok)
        return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s: aa_order is not frame, global, or aa_block_size not 1",
                        file->json.name);
    return GSF_OK;
}

static gsf_result gsf__vggt_check_sizes(gsf_context* ctx, const gsf_nn_weights* w, gsf__vggt* net) {
    const gsf__vit* vit = &net->embed;
    const int32_t heads = net->sizes.heads;
    const struct { const char* what; int64_t value, low, high; } sizes[] = {
        {"width", net->sizes.width, 1, 65536}, {"hidden layer", net->sizes.mlp, 1, 1 << 20},
        {"hidden layer", vit->sizes.mlp, 1, 1 << 20}, {"number of blocks", net->layers, 1, 1024},
        {"number of blocks", vit->layers, 1, 1024}, {"number of registers", net->registers, 0, 65536},
        {"number of registers", vit->registers, 0, 65536}, {"number of channels", vit->channels, 3, 3},
        {"patch", vit->patch, 1, 1024}, {"grid of positions", vit->grid, 1, 1 << 15}};
    for (size_t i = 0; i < GSF__COUNT(sizes); i++)
        if (sizes[i].value < sizes[i].low || sizes[i].value > sizes[i].high)
            return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: a %s of %lld", w->name, sizes[i].what,
                            (long long)sizes[i].value);
    if (heads < 1 || net->sizes.width % heads || (net->rope_base > 0.0 && net->sizes.width / heads % 4))
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %d heads of a width of %lld", w->name, (int)heads,
                        (long long)net->sizes.width);
    net->sizes.head_dim = (int32_t)(net->sizes.width / heads);
    net->embed.sizes.heads = heads;
    net->embed.sizes.head_dim = net->sizes.head_dim;
    return GSF_OK;
}

static gsf_result gsf__vggt_bind(gsf__nn_loader* loader, gsf__vggt* net) {
    const gsf__nn_entry* entries = gsf__vggt_block_entries;
    const gsf__nn_sizes sizes = gsf__vggt_sizes(net);
    GSF__TRY(gsf__vit_bind(loader, gsf__vggt_embed_entries, entries, "", &net->embed));
    GSF__TRY(gsf__nn_bind_blocks(loader, &net->sizes, entries, gsf__vggt_frame_names, net->layers, &net->frame));
    GSF__TRY(gsf__nn_bind_blocks(loader, &net->sizes, entries, gsf__vggt_global_names, net->layers, &net->global));
    return gsf__nn_bind(loader, &sizes, gsf__vggt_entries, "", net);
}

static gsf_result gsf__vggt_open(gsf_context* ctx, const char* path, gsf_nn_vggt* out, gsf__vggt* net) {
    gsf__nn_config file;
    gsf__nn_loader loader;
    GSF__TRY(gsf_nn_load_weights(ctx, path, "model", &out->weights));
    GSF__TRY(gsf__nn_begin_loading(ctx, &out->weights, &loader));
    for (size_t i = 0; i < out->weights.tensor_count; i++) // heads for cameras, depths, points and tracks are not used
        if (strncmp(out->weights.tensors[i].name, "aggregator.", 11) != 0) loader.taken[i] = 1;
    gsf__nn_ignore(&loader, "aggregator.patch_embed.mask_token"); // used in training only
    gsf_result result = gsf__vggt_read_shapes(&loader, net);
    net->rope_base = 100.0;
    if (!result && !gsf__nn_ends_in(path, ".safetensors")) {
        result = gsf__nn_open_config(ctx, path, "config.json", 1, &file);
        if (!result) result = gsf__vggt_read_config(&file, net);
        gsf__nn_close_config(&file);
    }
    if (!result) result = gsf__vggt_check_sizes(ctx, &out->weights, net);
    if (!result) result = gsf__vggt_bind(&loader, net);
    return gsf__nn_end_loading(&loader, result);
}

GSF_API void gsf_nn_destroy_vggt(gsf_context* ctx, gsf_nn_vggt* vggt) {
    gsf__vggt* net = (gsf__vggt*)vggt->nets;
    if (net) {
        gsf_free(ctx, net->embed.blocks);
        gsf_free(ctx, net->frame);
        gsf_free(ctx, net->global);
    }
    gsf_free(ctx, net);
    gsf_nn_destroy_weights(ctx, &vggt->weights);
    memset(vggt, 0, sizeof *vggt);
}

GSF_API gsf_result gsf_nn_load_vggt(gsf_context* ctx, const char* path, gsf_nn_vggt* out) {
    memset(out, 0, sizeof *out);
    gsf__vggt* net = (gsf__vggt*)gsf_alloc_zeroed(ctx, 1, sizeof *net);
    if (!net) return GSF_ERROR_OUT_OF_MEMORY;
    out->nets = net;
    const gsf_result result = gsf__vggt_open(ctx, path, out, net);
    out->width = (int32_t)net->sizes.width;
    out->heads = net->sizes.heads;
    out->layers = (int32_t)net->layers;
    out->mlp_width = (int32_t)net->sizes.mlp;
    out->patch = (int32_t)net->embed.patch;
    out->embed_layers = (int32_t)net->embed.layers;
    out->special = (int32_t)net->registers + 1;
    out->grid = (int32_t)net->embed.grid;
    out->rope_base = net->rope_base;
    if (result) gsf_nn_destroy_vggt(ctx, out);
    return result;
}

// Peak memory in bytes (in addition to input, output, mapped weights and about 70 MB of kernel scratch) and
// floating-point operations of an encoder call; either may be NULL. Reads only the sizes of the input.
static void gsf__nn_query_vggt(const gsf_nn_vggt* vggt, const gsf_nn_encoder_desc* input, double* bytes,
                               double* flops) {
    const gsf__vggt* net = (const gsf__vggt*)vggt->nets;
    const int64_t patch = net->embed.patch, patches = input->height / patch * (input->width / patch);
    const double images = (double)input->images, tokens = (double)(1 + net->registers + patches);
    if (bytes) *bytes = gsf__vit_bytes(&net->embed, net, input);
    if (!flops) return;
    *flops = gsf__vit_flops(&net->embed, input) +
             (double)net->layers * (gsf__nn_block_flops(&net->sizes, images, tokens) +
                                    gsf__nn_block_flops(&net->sizes, 1.0, images * tokens));
}

// RoPE tables of positions 1, 2, ...: angle position * base^(-i / count); cosine, sine (positions, count).
static void gsf__vggt_make_rotation(double base, int64_t positions, int64_t count, float* cosine, float* sine) {
    for (int64_t p = 0; p < positions; p++)
        for (int64_t i = 0; i < count; i++) {
            const double angle = (double)(p + 1) * pow(base, -(double)i / (double)count);
            cosine[p * count + i] = (float)cos(angle);
            sine[p * count + i] = (float)sin(angle);
        }
}

// Fills the stream (images, tokens, width): camera token, registers and the embedded patches of each image.
static gsf_result gsf__vggt_embed(gsf__nn_run* run, const gsf__vggt* net, const gsf_nn_encoder_desc* in,
                                  const gsf__vit_plan* plan) {
    const gsf__vit* vit = &net->embed;
    const int64_t d = net->sizes.width, special = 1 + net->registers, tokens = special + plan->patches;
    for (int64_t first = 0; first < in->images; first += plan->group) {
        const int64_t count = gsf__least(in->images - first, plan->group);
        GSF__TRY(gsf__vit_forward(run, vit, in, first, count, plan->positions, plan->x));
        for (int64_t i = 0; i < count; i++) {
            const float* patches = plan->x + (i * plan->tokens + 1 + vit->registers) * d;
            float* to = plan->stream + (first + i) * tokens * d;
            const int64_t other = first + i > 0;
            gsf_nn_convert_tensor(net->camera_token, other * d, d, to);
            gsf_nn_convert_tensor(net->register_token, other * net->registers * d, net->registers * d, to + d);
            gsf__nn_norm(run, &vit->norm, vit->sizes.eps, patches, plan->patches, to + special * d);
            gsf__nn_reveal(run, to + special * d, first + i, 1, plan->patches, d, "patch_tokens");
        }
    }
    return gsf__nn_check(run, "aggregator.", "aggregator.", plan->stream, in->images * tokens * d);
}

// Stores the tokens in one half of each output row: rows of `d` floats, 2 d apart (frame half first, then global).
static void gsf__vggt_store(const gsf__vit_plan* plan, const float* stream, int64_t images, int64_t special, int64_t skip,
                            int64_t d, float* out) {
    const int64_t tokens = special + plan->patches;
    for (int64_t i = 0; i < images; i++)
        for (int64_t t = skip; t < tokens; t++, out += 2 * d)
            memcpy(out, stream + (i * tokens + t) * d, (size_t)d * sizeof(float));
}

static gsf_result gsf__vggt_run(gsf__nn_run* run, const gsf__vggt* net, const gsf_nn_encoder_desc* in,
                                const gsf__vit_plan* plan, float* out) {
    const int64_t d = net->sizes.width, special = 1 + net->registers, tokens = special + plan->patches, n = in->images;
    const int64_t skip = in->all_tokens ? 0 : special, quarter = net->sizes.head_dim / 4;
    float* x = plan->stream;
    run->steps = (double)(gsf__ceil_div(n, plan->group) * net->embed.layers + 2 * net->layers);
    GSF__TRY(gsf__vggt_embed(run, net, in, plan));
    run->sizes = &net->sizes;
    run->image_tokens = tokens;
    run->special = special;
    run->across = in->width / net->embed.patch;
    if (plan->turn_count) {
        float* sine = plan->turns + plan->turn_count;
        gsf__vggt_make_rotation(net->rope_base, (int64_t)plan->turn_count / quarter, quarter, plan->turns, sine);
        run->cos = plan->turns;
        run->sin = sine;
    }
    for (int64_t layer = 0; layer < net->layers; layer++) {
        GSF__TRY(gsf__nn_block_forward(run, &net->frame[layer], layer, x, n, tokens));
        GSF__TRY(gsf__nn_end_block(run, gsf__vggt_frame_names, layer, x, n * tokens * d));
        gsf__nn_reveal(run, x, 0, n, tokens, d, "frame%lld", (long long)layer);
        if (layer + 1 == net->layers) gsf__vggt_store(plan, x, n, special, skip, d, out);
        GSF__TRY(gsf__nn_block_forward(run, &net->global[layer], layer, x, 1, n * tokens));
        GSF__TRY(gsf__nn_end_block(run, gsf__vggt_global_names, layer, x, n * tokens * d));
        gsf__nn_reveal(run, x, 0, n, tokens, d, "global%lld", (long long)layer);
    }
    gsf__vggt_store(plan, x, n, special, skip, d, out + d);
    return GSF_OK;
}

// Runs either encoder; net NULL: the DINOv2 alone.
static gsf_result gsf__vit_encode(gsf_context* ctx, const char* name, const gsf_nn_weights* weights, const gsf__vit* vit,
                                  const gsf__vggt* net, const gsf_nn_encoder_desc* in, float* out) {
    gsf__nn_run run;
    gsf__vit_plan plan;
    float* memory = NULL;
    memset(&run, 0, sizeof run);
    GSF__TRY(gsf__vit_check_input(ctx, name, vit->channels, vit->patch, in, out));
    run.ctx = ctx;
    run.name = run.stage = name;
    run.weights = weights;
    run.tap = in->_tap;
    gsf_result result = gsf__vit_open_run(&run, vit, net, in, &plan, &memory);
    if (!result) result = net ? gsf__vggt_run(&run, net, in, &plan, out) : gsf__dinov2_run(&run, vit, in, &plan, out);
    if (result) {
        const int64_t special = !in->all_tokens ? 0 : 1 + (net ? net->registers : vit->registers);
        const int64_t kept = special + in->height / vit->patch * (in->width / vit->patch);
        memset(out, 0, (size_t)(in->images * kept * vit->sizes.width * (net ? 2 : 1)) * sizeof(float));
    }
    gsf__nn_destroy_workspace(ctx, &run.workspace);
    gsf_free(ctx, memory);
    return result;
}

GSF_API gsf_result gsf_nn_encode_dinov2(gsf_context* ctx, const gsf_nn_dinov2* dinov2, const gsf_nn_encoder_desc* input,
                                        float* out) {
    return gsf__vit_encode(ctx, "dinov2", &dinov2->weights, (const gsf__vit*)dinov2->nets, NULL, input, out);
}

GSF_API gsf_result gsf_nn_encode_vggt(gsf_context* ctx, const gsf_nn_vggt* vggt, const gsf_nn_encoder_desc* input,
                                      float* out) {
    const gsf__vggt* net = (const gsf__vggt*)vggt->nets;
    return gsf__vit_encode(ctx, "vggt", &vggt->weights, &net->embed, net, input, out);
}

// ---- image encoders: from photos to features

enum { GSF__REFERENCE_SIDE = 518, GSF__REFERENCE_PATCH = 14 };

// One channel of Pillow's Image.alpha_composite over opaque white (AlphaComposite.c, with 7 fractional bits).
static uint8_t gsf__over_white(uint32_t value, uint32_t alpha) {
    const uint32_t weighted = (value * alpha + 255u * (255u - alpha)) * 128u + (0x80u << 7);
    return (uint8_t)(((weighted >> 8) + weighted) >> 8 >> 7);
}

// Converts the photo to u8 with 3 channels, at its size.
static gsf_result gsf__reference_rgb(gsf_context* ctx, const gsf_image* photo, gsf_image* out) {
    gsf_image bytes;
    memset(&bytes, 0, sizeof bytes);
    GSF__TRY(gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 3, out));
    if (photo->channels != 4) return gsf_convert_image(ctx, photo, out);
    GSF__TRY(gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 4, &bytes));
    const gsf_result result = gsf_convert_image(ctx, photo, &bytes);
    const uint8_t* from = (const uint8_t*)bytes.data;
    uint8_t* to = (uint8_t*)out->data;
    for (int64_t i = 0; i < photo->width * photo->height; i++, from += 4, to += 3)
        for (int c = 0; c < 3; c++) to[c] = gsf__over_white(from[c], from[3]);
    gsf_destroy_image(ctx, &bytes);
    return result;
}

// Preprocesses a reference as the GSFixer release does (vggt/utils/load_fn.py load_and_preprocess_images, mode "crop"):
// alpha composited over white, resized to 518 pixels wide with PIL's bicubic filter, the height rounded to a multiple
// of 14 (half to even) and center-cropped if above 518. Photos have 1, 3 or 4 channels; float ones are rounded to 8
// bits first. out: u8, 3 channels; the caller destroys it.
static gsf_result gsf__nn_prepare_reference(gsf_context* ctx, const gsf_image* photo, gsf_image* out) {
    gsf_image rgb, whole;
    memset(&rgb, 0, sizeof rgb);
    memset(&whole, 0, sizeof whole);
    memset(out, 0, sizeof *out);
    if (!photo->data || photo->width < 1 || photo->height < 1 ||
        (photo->channels != 1 && photo->channels != 3 && photo->channels != 4))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "reference: a photo of %lld x %lld with %d channels",
                        (long long)photo->width, (long long)photo->height, (int)photo->channels);
    const double side = GSF__REFERENCE_SIDE, patch = GSF__REFERENCE_PATCH;
    const double patches = rint((double)photo->height * (side / (double)photo->width) / patch);
    if (patches < 1.0 || patches > 4096.0)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "reference: a photo of %lld x %lld would become %g pixels high",
                        (long long)photo->width, (long long)photo->height, patches * patch);
    const int64_t height = (int64_t)patches * GSF__REFERENCE_PATCH;
    const int64_t kept = gsf__least(height, GSF__REFERENCE_SIDE), top = (height - kept) / 2;
    gsf_result result = gsf__reference_rgb(ctx, photo, &rgb);
    if (!result) result = gsf_make_image(ctx, GSF_U8, GSF__REFERENCE_SIDE, height, 3, &whole);
    if (!result) result = gsf_resize_image(ctx, &rgb, GSF_RESIZE_PIL_BICUBIC, &whole);
    if (!result) result = gsf_make_image(ctx, GSF_U8, GSF__REFERENCE_SIDE, kept, 3, out);
    if (!result)
        memcpy(out->data, (const uint8_t*)whole.data + top * whole.stride_y, (size_t)(kept * out->stride_y));
    gsf_destroy_image(ctx, &rgb);
    gsf_destroy_image(ctx, &whole);
    if (result) gsf_destroy_image(ctx, out);
    return result;
}

// Preprocesses the photos to (count, 3, height, width) in [0,1]; the caller frees *pixels, also on error.
static gsf_result gsf__load_references(gsf_context* ctx, const gsf_image* photos, int32_t count, float** pixels,
                                       gsf_nn_encoder_desc* in) {
    size_t floats = 0, plane = 0;
    for (int32_t i = 0; i < count; i++) {
        gsf_image image, planar;
        GSF__TRY(gsf__nn_prepare_reference(ctx, &photos[i], &image));
        gsf_result result = GSF_OK;
        if (i == 0) {
            plane = (size_t)(image.width * image.height);
            in->height = (int32_t)image.height;
            in->width = (int32_t)image.width;
            if (!gsf__mul_size(3 * plane, (size_t)count, &floats)) result = GSF_ERROR_OUT_OF_MEMORY;
            else if ((*pixels = (float*)gsf_alloc(ctx, floats, sizeof(float))) == NULL) result = GSF_ERROR_OUT_OF_MEMORY;
        } else if (image.height != in->height) {
            result = gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "references: photo %d becomes %lld pixels high, the first %d",
                              (int)i, (long long)image.height, (int)in->height);
        }
        if (!result) {
            planar = gsf_wrap_image(*pixels + (size_t)i * 3 * plane, GSF_F32, image.width, image.height, 3);
            planar.stride_x = sizeof(float);
            planar.stride_y = image.width * (int64_t)sizeof(float);
            planar.stride_c = (int64_t)(plane * sizeof(float));
            result = gsf_convert_image(ctx, &image, &planar);
        }
        gsf_destroy_image(ctx, &image);
        if (result) return result;
    }
    in->pixels = *pixels;
    in->images = count;
    return GSF_OK;
}

// Allocates (images, tokens, channels) values in the features; features of an earlier call must have the same images
// and tokens.
static gsf_result gsf__room_for_features(gsf_context* ctx, gsf_nn_features* f, const gsf_nn_encoder_desc* in,
                                         int64_t patch, int64_t channels, float** values, int64_t* of) {
    size_t count;
    if (in->height % patch || in->width % patch)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "references: %d x %d pixels are not multiples of a patch of %lld",
                        (int)in->width, (int)in->height, (long long)patch);
    const int64_t tokens = in->height / patch * (in->width / patch);
    if ((f->dino || f->vggt) && (f->images != in->images || f->tokens != tokens))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "references: %lld images of %lld tokens before, now %d of %lld",
                        (long long)f->images, (long long)f->tokens, (int)in->images, (long long)tokens);
    gsf_free(ctx, *values);
    *values = NULL;
    *of = 0;
    if (!gsf__mul_size((size_t)in->images * (size_t)tokens, (size_t)channels, &count)) return GSF_ERROR_OUT_OF_MEMORY;
    *values = (float*)gsf_alloc(ctx, count, sizeof(float));
    if (!*values) return GSF_ERROR_OUT_OF_MEMORY;
    f->images = in->images;
    f->tokens = tokens;
    *of = channels;
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_encode_references(gsf_context* ctx, const gsf_nn_dinov2* dinov2, const gsf_nn_vggt* vggt,
                                            const gsf_image* photos, int32_t count, gsf_nn_features* features) {
    gsf_nn_features* f = features;
    gsf_nn_encoder_desc in;
    float* pixels = NULL;
    memset(&in, 0, sizeof in);
    if (!photos || count < 1) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "references: no photos given");
    gsf_result result = gsf__load_references(ctx, photos, count, &pixels, &in);
    if (!result && dinov2) {
        result = gsf__room_for_features(ctx, f, &in, dinov2->patch, dinov2->width, &f->dino, &f->dino_channels);
        if (!result) result = gsf_nn_encode_dinov2(ctx, dinov2, &in, f->dino);
    }
    if (!result && vggt) {
        result = gsf__room_for_features(ctx, f, &in, vggt->patch, 2 * (int64_t)vggt->width, &f->vggt, &f->vggt_channels);
        if (!result) result = gsf_nn_encode_vggt(ctx, vggt, &in, f->vggt);
    }
    gsf_free(ctx, pixels);
    float** const made[2] = {dinov2 ? &f->dino : NULL, vggt ? &f->vggt : NULL};
    for (int i = 0; result && i < 2; i++) {
        if (!made[i]) continue;
        gsf_free(ctx, *made[i]);
        *made[i] = NULL;
    }
    return result;
}

GSF_API void gsf_nn_destroy_features(gsf_context* ctx, gsf_nn_features* features) {
    gsf_free(ctx, features->dino);
    gsf_free(ctx, features->vggt);
    memset(features, 0, sizeof *features);
}

// ---- >>nn bpe -------------------------------------------------------------------

/* Byte-level byte-pair encoding (Sennrich et al. 2016; Radford et al. 2019) as transformers 4.51.3 does it in
   models/gpt2/tokenization_gpt2.py and tokenization_utils.py:
       text | cut out added tokens | split into words by a pattern | bytes | merge neighbours, lowest rank first | ids
   The files spell each byte as a character: printable Latin-1 as itself, the other 68 bytes as U+0100 and up, in order.
       vocab.json    {"token": id, ...}
       merges.txt    a comment line, then lines "left right", lowest rank first
   The merges of a word are applied rank by rank, and within a rank from left to right. Candidates are kept in a heap,
   so that a word of a megabyte takes O(n log n). The merge table is sorted by left token, then by right token. */

enum { GSF__BPE_OTHER, GSF__BPE_LETTER, GSF__BPE_NUMBER, GSF__BPE_SPACE }; // character classes of the pattern

// Classes of all characters as runs from U+0000 on, each 4 * length + class; characters after the last run are
// GSF__BPE_OTHER. Loading a tokenizer unpacks these 3.3 KB to 2 bits per character. Generated with the `regex` package,
// which transformers' GPT2Tokenizer uses (2026.11.15, Unicode 18; for characters that unicodedata knows these are its
// categories L* and N* and White_Space):
//     import regex
//     kind = [next((k for k, p in ((1, r"\p{L}"), (2, r"\p{N}"), (3, r"\s")) if regex.match(p, chr(c))), 0)
//             for c in range(0x110000)]
//     start = 0
//     for c in range(1, 0x110000):
//         if kind[c] != kind[start] or c - start == 16383:
//             print(4 * (c - start) + kind[start], end=",")
//             start = c
static const uint16_t gsf__bpe_kinds[] = {
    36,23,72,7,60,42,28,105,24,105,40,7,104,7,36,5,28,10,4,5,12,6,5,4,14,4,93,4,125,4,1833,16,49,56,21,28,5,4,5,516,
    21,4,9,8,17,4,5,24,5,4,13,4,5,4,81,4,333,4,557,32,665,4,153,4,9,24,165,8,9,268,109,16,17,180,173,84,42,16,9,4,397,
    4,5,60,9,28,9,42,13,8,5,64,5,4,121,116,357,44,5,56,42,133,36,9,16,5,20,89,16,5,36,5,12,5,92,101,28,45,20,97,4,29,
    64,169,232,217,12,5,72,5,28,41,16,42,4,65,16,33,8,9,8,89,4,29,4,5,12,17,12,5,64,5,52,9,4,13,16,42,9,8,26,8,5,32,
    25,16,9,8,89,4,29,4,9,4,9,4,9,124,17,4,5,28,42,8,13,64,37,4,13,4,89,4,29,4,9,4,21,12,5,72,5,60,9,16,42,36,5,44,33,
    8,9,8,89,4,29,4,9,4,21,12,5,120,9,4,13,16,42,4,5,26,44,5,4,25,12,13,4,17,12,9,4,5,4,9,12,9,12,13,12,49,88,5,84,54,
    72,33,4,13,4,93,4,65,12,5,104,13,4,9,8,9,16,42,32,30,4,5,16,33,4,13,4,93,4,41,4,21,12,5,120,13,4,9,16,42,4,9,68,
    37,4,13,4,165,8,5,64,5,20,13,4,30,13,16,78,4,25,20,73,12,97,4,37,4,5,8,29,124,42,68,193,4,9,48,29,36,42,156,9,4,5,
    4,21,4,97,4,5,4,41,4,9,36,5,8,21,4,5,36,42,8,17,128,5,124,82,48,33,4,145,108,21,460,173,80,5,42,24,25,16,17,12,5,
    12,9,28,13,16,53,48,5,4,42,24,153,4,5,20,5,8,173,4,1333,4,17,8,29,4,5,4,17,8,165,4,17,8,133,4,17,8,29,4,5,4,17,8,
    61,4,229,4,17,8,269,56,82,12,65,64,345,8,25,12,2481,8,69,7,105,20,301,12,14,33,28,73,52,77,56,73,56,53,4,13,60,
    209,140,5,16,5,12,42,24,42,88,42,24,357,28,21,8,137,4,5,20,281,40,125,156,42,121,8,21,44,177,16,105,24,46,148,93,
    36,213,172,42,24,42,52,5,372,189,68,33,12,42,164,121,52,9,42,177,104,145,112,42,12,13,42,145,8,45,20,173,8,13,164,
    17,4,25,4,9,12,5,20,769,256,1113,8,25,8,153,8,25,8,33,4,5,4,5,4,5,4,125,8,213,4,29,4,5,12,13,4,29,12,17,8,25,16,
    53,20,13,4,29,12,47,116,11,20,7,188,7,64,6,5,8,26,20,5,42,20,69,392,5,16,5,8,41,4,5,12,21,24,5,4,5,4,5,4,17,4,45,
    8,17,20,21,16,5,4,206,9,22,2904,242,312,90,2520,122,4528,917,24,17,12,9,36,6,8,153,4,5,20,5,8,225,28,5,64,93,36,
    29,4,29,4,29,4,29,4,29,4,29,4,29,4,29,320,5,1856,7,16,9,6,100,38,28,21,8,14,9,16,345,24,13,4,361,4,17,20,173,4,
    377,12,18,40,129,192,65,128,42,120,34,4,62,128,42,156,62,1280,26369,256,65533,23097,268,185,8,1077,12,65,42,9,80,
    189,64,125,8,281,42,156,37,8,413,8,333,16,5,56,69,4,13,4,17,4,93,52,26,40,209,56,201,112,42,96,25,12,5,4,9,4,42,
    113,40,93,100,117,28,189,112,5,42,24,21,4,41,42,21,4,165,92,13,4,33,16,42,24,93,12,5,12,201,4,5,12,9,8,21,8,5,4,5,
    96,13,8,45,28,13,48,25,8,25,8,25,36,29,4,29,4,173,4,57,8,9,8,461,52,42,24,44689,48,93,16,197,33808,1465,8,425,152,
    29,48,21,20,5,4,41,4,53,4,21,4,5,4,9,4,9,4,433,132,1453,72,257,8,217,160,49,464,21,4,541,76,42,28,105,24,105,44,
    357,12,25,8,25,8,25,8,13,140,49,4,105,4,77,4,9,4,61,8,57,136,493,48,182,48,230,68,10,976,117,12,197,64,110,16,129,
    18,36,81,6,33,6,20,153,40,121,8,145,16,33,4,22,168,633,8,42,24,145,16,145,16,161,32,209,48,45,4,61,4,29,4,9,4,45,
    4,61,4,29,4,9,12,209,48,1245,36,89,40,33,96,25,4,169,4,57,256,25,8,5,4,177,4,9,12,5,8,93,8,34,93,8,30,125,32,38,
    192,77,4,9,20,22,89,26,16,105,24,105,152,225,16,10,9,66,8,186,5,60,17,4,13,4,117,40,38,92,117,10,4,117,14,128,33,
    4,113,24,22,64,217,40,89,8,34,77,20,34,73,92,30,320,293,220,205,52,205,28,26,145,48,42,24,42,113,36,93,872,126,4,
    169,24,9,64,25,68,89,68,117,42,5,32,89,44,18,108,73,184,85,30,80,93,48,213,104,122,4,9,8,5,52,181,128,101,28,42,
    36,145,60,42,16,5,8,5,32,141,12,5,48,193,56,17,44,42,5,4,5,16,82,44,73,4,101,76,9,252,29,4,5,4,17,4,61,4,41,28,
    189,68,42,44,33,8,9,8,89,4,29,4,9,4,21,12,5,72,5,48,21,120,41,4,5,8,5,4,153,4,5,100,5,4,5,176,213,72,17,20,42,20,
    13,120,193,80,9,4,5,32,42,664,189,164,17,144,193,80,5,44,42,152,173,52,5,28,42,24,82,112,109,84,50,16,29,740,177,
    464,257,78,48,33,8,5,8,33,4,9,4,97,60,5,4,5,56,42,280,33,8,157,64,5,4,5,112,5,40,161,28,5,84,5,44,185,76,5,72,293,
    68,5,724,133,60,42,24,37,4,149,68,5,60,118,20,121,448,29,4,9,4,153,84,5,36,42,24,25,4,9,4,129,56,5,28,42,24,177,
    16,42,28,5,952,77,60,5,4,53,4,137,112,42,344,5,60,86,172,3689,408,450,20,46,785,48,1246,9252,389,60,4289,68,25,
    100,15981,20,2333,27364,121,72,42,6936,2277,28,125,4,42,24,317,4,42,24,121,72,193,64,17,48,42,4,30,4,85,20,77,
    1728,181,12,42,792,257,94,36,101,8,101,176,301,20,5,264,53,256,9,4,5,56,9,14,36,29549,144,137,380,461,52,3657,56,
    205,30836,17,4,29,4,9,4,1189,36,5,116,13,8,5,56,21,28,1585,9232,429,20,53,12,37,28,41,16728,42,5912,82,48,82,432,
    102,540,341,4,285,4,9,8,5,8,9,8,17,4,49,4,5,4,29,4,261,4,17,8,33,4,29,4,113,4,17,4,21,4,5,12,29,4,1365,4,101,4,
    101,4,125,4,101,4,125,4,101,4,125,4,101,4,125,4,101,4,33,8,202,7168,521,56,29,216,205,192,249,584,181,40,29,8,42,
    16,5,1284,121,72,177,16,42,1880,113,16,42,856,121,8,5,42,788,125,4,13,4,9,4,29,8,21,36,9,896,29,4,17,4,9,4,61,4,
    789,8,38,192,273,28,5,16,42,3164,238,4,14,4,18,304,182,4,62,776,17,4,109,4,9,4,5,8,5,4,41,4,17,4,5,4,5,24,5,16,5,
    4,5,4,5,4,13,4,9,4,5,8,5,4,5,4,5,4,5,4,5,4,9,4,5,8,17,4,29,4,17,4,17,4,5,4,41,4,69,20,13,4,21,4,69,2320,54,11148,
    42,4120,65533,65533,39817,128,17533,4,23097,8,29893,60,2489,9864,2169,6024,19757,20,33961,65532,65532,28192,45313
};

enum { GSF__BPE_CHARACTERS = 0x40000 }; // all characters above are GSF__BPE_OTHER

enum { // flags of tokens
    GSF__BPE_ADDED = 1,   // cut out of texts before splitting, and spelled literally
    GSF__BPE_SPECIAL = 2, // omitted when decoding without special tokens
    GSF__BPE_LSTRIP = 4,  // also consumes the white space before it
    GSF__BPE_RSTRIP = 8,  // also consumes the white space after it
    GSF__BPE_APART = 16,  // surrounded by spaces in decoded text
    GSF__BPE_OBJECT = 32  // given as an object in the JSON files
};

enum { GSF__BPE_ADDED_MAX = 4096 };

typedef struct gsf__bpe_token {
    const char* text; // as spelled in the files
    size_t size;
    int32_t id, flags;
} gsf__bpe_token;

typedef struct gsf__bpe_merge {
    int32_t left, right, result; // indices of vocabulary tokens
    int32_t rank;
} gsf__bpe_merge;

typedef struct gsf__bpe_tables { // pointed to by gsf_nn_bpe.tables
    gsf__nn_config config, special_map, added_tokens; // own the texts of added tokens
    char* strings;           // texts of the vocabulary
    gsf__bpe_token* tokens;  // (vocabulary) sorted by text
    gsf__bpe_token* added;   // (added_count) sorted by text
    gsf__bpe_token* by_id;   // (by_id_count) all tokens
    gsf__bpe_merge* merges;  // (first[vocabulary]) sorted by left, then right
    int32_t* first;          // merges whose left token is t: first[t] ... first[t + 1] - 1
    unsigned char* kinds;    // 2 bits per character
    size_t added_capacity;
    int32_t vocabulary, added_count, by_id_count;
    int32_t bytes[256];      // tokens of single bytes, -1: none
    int prefix_space, clean_up, split_special;
} gsf__bpe_tables;

// ---- bytes and characters

static uint32_t gsf__bpe_character(unsigned byte) { // the character that spells the byte
    if (byte <= 32) return 256 + byte;
    if (byte >= 127 && byte <= 160) return 289 + byte - 127;
    return byte == 173 ? 323 : byte;
}

static int gsf__bpe_byte(uint32_t character) { // -1: the character spells no byte
    if (character >= 256 && character <= 288) return (int)character - 256;
    if (character >= 289 && character <= 322) return (int)character - 289 + 127;
    if (character == 323) return 173;
    return character > 255 || character != gsf__bpe_character(character) ? -1 : (int)character;
}

static size_t gsf__bpe_store_character(uint32_t character, char* out) { // of a character below U+0800
    if (character < 0x80) {
        out[0] = (char)character;
        return 1;
    }
    out[0] = (char)(0xc0 | character >> 6);
    out[1] = (char)(0x80 | (character & 0x3f));
    return 2;
}

static uint32_t gsf__bpe_load_character(const char* text, size_t size) { // of a well-formed character of `size` bytes
    static const unsigned char first[] = {0, 0x7f, 0x1f, 0x0f, 0x07};
    uint32_t character = (unsigned char)text[0] & first[size];
    for (size_t i = 1; i < size; i++) character = character << 6 | ((unsigned char)text[i] & 0x3f);
    return character;
}

static int gsf__bpe_kind(const gsf__bpe_tables* t, const char* text, size_t left, size_t* size) {
    *size = gsf__utf8_size(text, left);
    const uint32_t character = gsf__bpe_load_character(text, *size);
    return character < GSF__BPE_CHARACTERS ? t->kinds[character >> 2] >> 2 * (character & 3) & 3 : GSF__BPE_OTHER;
}

// What Python's str.strip removes: the pattern's white space and four control characters.
static int gsf__bpe_strips(const gsf__bpe_tables* t, const char* text, size_t left, size_t* size) {
    return gsf__bpe_kind(t, text, left, size) == GSF__BPE_SPACE || (text[0] >= 0x1c && text[0] <= 0x1f);
}

// Shrinks [*begin, *end) of well-formed UTF-8 by the white space at its left and / or right end.
static void gsf__bpe_strip(const gsf__bpe_tables* t, const char* text, int left, int right, size_t* begin, size_t* end) {
    size_t size;
    while (left && *begin < *end && gsf__bpe_strips(t, text + *begin, *end - *begin, &size)) *begin += size;
    while (right && *begin < *end) {
        size_t at = *end - 1;
        while (((unsigned char)text[at] & 0xc0) == 0x80) at--;
        if (!gsf__bpe_strips(t, text + at, *end - at, &size)) return;
        *end = at;
    }
}

static gsf_result gsf__bpe_unpack_kinds(gsf_context* ctx, gsf__bpe_tables* t) {
    uint32_t character = 0;
    t->kinds = (unsigned char*)gsf_alloc_zeroed(ctx, GSF__BPE_CHARACTERS / 4, 1);
    if (!t->kinds) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < GSF__COUNT(gsf__bpe_kinds); i++) {
        const uint32_t kind = gsf__bpe_kinds[i] & 3u, end = character + gsf__bpe_kinds[i] / 4;
        while (character < end) { // four at a time when they share a byte
            const int four = character % 4 == 0 && end - character >= 4;
            t->kinds[character >> 2] |= (unsigned char)(four ? 0x55 * kind : kind << 2 * (character & 3));
            character += four ? 4 : 1;
        }
    }
    return GSF_OK;
}

// ---- loading

typedef struct gsf__bpe_loader {
    gsf_context* ctx;
    const char* folder;
    gsf__bpe_tables* t;
    const gsf_json_value* decoder; // "added_tokens_decoder" of tokenizer_config.json, or NULL
    gsf_buffer scratch;
} gsf__bpe_loader;

static int gsf__bpe_compare(const char* a, size_t a_size, const char* b, size_t b_size) {
    const int order = memcmp(a, b, a_size < b_size ? a_size : b_size);
    return order ? order : a_size < b_size ? -1 : a_size > b_size;
}

static int gsf__bpe_compare_texts(const void* a, const void* b) {
    const gsf__bpe_token *x = (const gsf__bpe_token*)a, *y = (const gsf__bpe_token*)b;
    return gsf__bpe_compare(x->text, x->size, y->text, y->size);
}

// an added token precedes a vocabulary token of the same id
static int gsf__bpe_compare_ids(const void* a, const void* b) {
    const gsf__bpe_token *x = (const gsf__bpe_token*)a, *y = (const gsf__bpe_token*)b;
    if (x->id != y->id) return x->id < y->id ? -1 : 1;
    if ((x->flags & GSF__BPE_ADDED) != (y->flags & GSF__BPE_ADDED)) return x->flags & GSF__BPE_ADDED ? -1 : 1;
    return gsf__bpe_compare_texts(a, b);
}

static int gsf__bpe_compare_merges(const void* a, const void* b) {
    const gsf__bpe_merge *x = (const gsf__bpe_merge*)a, *y = (const gsf__bpe_merge*)b;
    if (x->left != y->left) return x->left < y->left ? -1 : 1;
    if (x->right != y->right) return x->right < y->right ? -1 : 1;
    return x->rank < y->rank ? -1 : x->rank > y->rank;
}

// Index of a vocabulary token, or -1.
static int32_t gsf__bpe_find(const gsf__bpe_tables* t, const char* text, size_t size) {
    int32_t low = 0, high = t->vocabulary;
    while (low < high) {
        const int32_t middle = low + (high - low) / 2;
        const int order = gsf__bpe_compare(t->tokens[middle].text, t->tokens[middle].size, text, size);
        if (order == 0) return middle;
        if (order < 0) low = middle + 1;
        else high = middle;
    }
    return -1;
}

// linear search, as they are not sorted yet
static int32_t gsf__bpe_find_added(const gsf__bpe_tables* t, const char* text, size_t size) {
    for (int32_t i = 0; i < t->added_count; i++)
        if (t->added[i].size == size && memcmp(t->added[i].text, text, size) == 0) return i;
    return -1;
}

// First entry of by_id whose id is at least `id`.
static int32_t gsf__bpe_find_id(const gsf__bpe_tables* t, int32_t id) {
    int32_t low = 0, high = t->by_id_count;
    while (low < high) {
        const int32_t middle = low + (high - low) / 2;
        if (t->by_id[middle].id < id) low = middle + 1;
        else high = middle;
    }
    return low;
}

static gsf_result gsf__bpe_copy_tokens(gsf__bpe_loader* l, const gsf_json* json) {
    const gsf_json_value* root = json->values;
    size_t bytes = 0;
    for (uint32_t i = root->child; i; i = json->values[i].next) bytes += json->values[i].key_size + 1;
    if (root->count < 1 || root->count > INT32_MAX / 2)
        return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s:0: %u tokens", json->name, (unsigned)root->count);
    l->t->strings = (char*)gsf_alloc(l->ctx, bytes, 1);
    l->t->tokens = (gsf__bpe_token*)gsf_alloc(l->ctx, root->count, sizeof *l->t->tokens);
    if (!l->t->strings || !l->t->tokens) return GSF_ERROR_OUT_OF_MEMORY;
    char* text = l->t->strings;
    for (uint32_t i = root->child; i; i = json->values[i].next) {
        const gsf_json_value* value = &json->values[i];
        if (value->type != GSF_JSON_NUMBER || !(value->number >= 0.0) || value->number > (double)INT32_MAX ||
            floor(value->number) != value->number)
            return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s:%u: the id of %s is not an integer from 0 to %d", json->name,
                            (unsigned)value->offset, gsf__nn_show(value->key).text, (int)INT32_MAX);
        if (value->key_size == 0)
            return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s:%u: an empty token", json->name, (unsigned)value->offset);
        gsf__bpe_token* token = &l->t->tokens[l->t->vocabulary++];
        token->text = text;
        token->size = value->key_size;
        token->id = (int32_t)value->number;
        token->flags = 0;
        memcpy(text, value->key, value->key_size + 1);
        text += value->key_size + 1;
    }
    qsort(l->t->tokens, (size_t)l->t->vocabulary, sizeof *l->t->tokens, gsf__bpe_compare_texts);
    return GSF_OK;
}

static gsf_result gsf__bpe_read_vocabulary(gsf__bpe_loader* l) {
    gsf__nn_config file;
    gsf_result result = gsf__nn_open_config(l->ctx, l->folder, "vocab.json", 0, &file);
    if (!result) result = gsf__bpe_copy_tokens(l, &file.json);
    gsf__nn_close_config(&file);
    for (unsigned byte = 0; byte < 256 && !result; byte++) {
        char text[2];
        l->t->bytes[byte] = gsf__bpe_find(l->t, text, gsf__bpe_store_character(gsf__bpe_character(byte), text));
    }
    return result;
}

static gsf_result gsf__bpe_need_token(gsf__bpe_loader* l, int32_t line, const char* text, size_t size, int32_t* out) {
    *out = gsf__bpe_find(l->t, text, size);
    if (*out >= 0) return GSF_OK;
    char shown[64];
    snprintf(shown, sizeof shown, "%.*s", size < 60 ? (int)size : 60, text);
    return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "merges.txt:%d: %s is not in vocab.json", (int)line,
                    gsf__nn_show(shown).text);
}

static int gsf__bpe_is_blank(char c) { return c == ' ' || c == '\t' || c == '\v' || c == '\f'; }

// Parses one line; lines are numbered from 1. A blank line sets *found to 0.
static gsf_result gsf__bpe_read_merge(gsf__bpe_loader* l, const char* line, size_t size, int32_t number,
                                      gsf__bpe_merge* out, int* found) {
    const char* parts[2] = {NULL, NULL};
    size_t sizes[2] = {0, 0}, count = 0;
    for (size_t i = 0; i < size;) {
        if (gsf__bpe_is_blank(line[i])) {
            i++;
            continue;
        }
        const size_t start = i;
        while (i < size && !gsf__bpe_is_blank(line[i])) i++;
        if (count < 2) {
            parts[count] = line + start;
            sizes[count] = i - start;
        }
        count++;
    }
    *found = count == 2;
    if (count == 0) return GSF_OK;
    if (count != 2)
        return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "merges.txt:%d: %zu tokens, not two", (int)number, count);
    out->rank = number;
    GSF__TRY(gsf__bpe_need_token(l, number, parts[0], sizes[0], &out->left));
    GSF__TRY(gsf__bpe_need_token(l, number, parts[1], sizes[1], &out->right));
    l->scratch.size = 0;
    gsf_append_bytes(l->ctx, &l->scratch, parts[0], sizes[0]);
    gsf_append_bytes(l->ctx, &l->scratch, parts[1], sizes[1]);
    if (l->scratch.failed) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf__bpe_need_token(l, number, l->scratch.data, l->scratch.size, &out->result);
}

// Lines end in \n, \r\n or \r. As in transformers' GPT2Tokenizer the first line is always skipped as a comment, text
// after the last line end is ignored, and of two equal merges the later one wins.
static gsf_result gsf__bpe_parse_merges(gsf__bpe_loader* l, const char* text, size_t size) {
    gsf__bpe_tables* t = l->t;
    size_t lines = 0, count = 0, kept = 0;
    for (size_t i = 0; i < size; i++) lines += text[i] == '\n' || text[i] == '\r';
    if (lines > INT32_MAX / 2) return gsf_fail(l->ctx, GSF_ERROR_UNSUPPORTED, "merges.txt: %zu lines", lines);
    t->merges = (gsf__bpe_merge*)gsf_alloc(l->ctx, lines + 1, sizeof *t->merges);
    t->first = (int32_t*)gsf_alloc_zeroed(l->ctx, (size_t)t->vocabulary + 1, sizeof *t->first);
    if (!t->merges || !t->first) return GSF_ERROR_OUT_OF_MEMORY;
    int32_t number = 1;
    for (size_t i = 0, start = 0; i < size; i++) {
        if (text[i] != '\n' && text[i] != '\r') continue;
        int found = 0;
        if (number > 1) GSF__TRY(gsf__bpe_read_merge(l, text + start, i - start, number, &t->merges[count], &found));
        count += (size_t)found;
        number++;
        if (text[i] == '\r' && i + 1 < size && text[i + 1] == '\n') i++;
        start = i + 1;
    }
    if (count) qsort(t->merges, count, sizeof *t->merges, gsf__bpe_compare_merges);
    for (size_t i = 0; i < count; i++) {
        const gsf__bpe_merge* m = &t->merges[i];
        if (i + 1 < count && m[1].left == m->left && m[1].right == m->right) continue;
        t->first[m->left + 1]++;
        t->merges[kept++] = *m;
    }
    for (int32_t i = 0; i < t->vocabulary; i++) t->first[i + 1] += t->first[i];
    return GSF_OK;
}

static gsf_result gsf__bpe_read_merges(gsf__bpe_loader* l) {
    void* data = NULL;
    size_t size;
    gsf_buffer path;
    gsf_result result = gsf__nn_join(l->ctx, l->folder, "merges.txt", &path);
    if (!result) result = gsf_read_file(l->ctx, path.data, &data, &size);
    if (!result) result = gsf__bpe_parse_merges(l, (const char*)data, size);
    gsf_free(l->ctx, data);
    gsf_destroy_buffer(l->ctx, &path);
    return result;
}

// ---- loading: added and special tokens

// A token is a string, or an object with the string in "content" plus flags. The caller sets the id.
static gsf_result gsf__bpe_read_token(const gsf__nn_config* file, const gsf_json_value* value, gsf__bpe_token* out) {
    const gsf_json* json = &file->json;
    static const struct { const char* key; int flag; } keys[] = {
        {"lstrip", GSF__BPE_LSTRIP}, {"rstrip", GSF__BPE_RSTRIP}, {"special", GSF__BPE_SPECIAL}, {"single_word", 0}};
    const gsf_json_value* text = value->type == GSF_JSON_OBJECT ? gsf_find_json_member(json, value, "content") : value;
    memset(out, 0, sizeof *out);
    if (!text || text->type != GSF_JSON_STRING || text->string_size == 0)
        return gsf_fail(file->ctx, GSF_ERROR_FORMAT,
                        "%s:%u: not a token: expected a string or an object with \"content\"", json->name,
                        (unsigned)value->offset);
    out->text = text->string;
    out->size = text->string_size;
    out->id = -1;
    out->flags = GSF__BPE_ADDED | (value->type == GSF_JSON_OBJECT ? GSF__BPE_OBJECT : 0);
    for (size_t i = 0; i < GSF__COUNT(keys) && value->type == GSF_JSON_OBJECT; i++) {
        int flag;
        GSF__TRY(gsf__nn_config_flag(file, gsf_find_json_member(json, value, keys[i].key), keys[i].key, 0, &flag));
        if (flag && !keys[i].flag)
            return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s:%u: %s of token %s", json->name, (unsigned)value->offset,
                            keys[i].key, gsf__nn_show(out->text).text);
        if (flag) out->flags |= keys[i].flag;
    }
    return GSF_OK;
}

static gsf_result gsf__bpe_add(void* user, const gsf__bpe_token* token) {
    gsf__bpe_loader* l = (gsf__bpe_loader*)user;
    gsf__bpe_tables* t = l->t;
    const size_t count = (size_t)t->added_count;
    if (count == GSF__BPE_ADDED_MAX)
        return gsf_fail(l->ctx, GSF_ERROR_UNSUPPORTED, "%s: more than %d added tokens", l->folder, (int)count);
    if (gsf__bpe_find_added(t, token->text, token->size) >= 0)
        return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s: token %s is added twice", l->folder,
                        gsf__nn_show(token->text).text);
    GSF__TRY(gsf__reserve(l->ctx, (void**)&t->added, &t->added_capacity, count, count + 1, sizeof *t->added));
    t->added[t->added_count++] = *token;
    return GSF_OK;
}

// Calls `add` for each member of `decoder`, "added_tokens_decoder" of tokenizer_config.json, {"id": token, ...}; if that
// is NULL, of added_tokens.json, {"token": id, ...}.
static gsf_result gsf__nn_read_added(const gsf__nn_config* config, const gsf_json_value* decoder,
                                     const gsf__nn_config* added,
                                     gsf_result (*add)(void* user, const gsf__bpe_token* token), void* user) {
    const gsf__nn_config* file = decoder ? config : added;
    const gsf_json* json = &file->json;
    const gsf_json_value* map = decoder ? decoder : json->values;
    if (map->type != GSF_JSON_OBJECT)
        return gsf_fail(file->ctx, GSF_ERROR_FORMAT, "%s:%u: the added tokens are not an object", json->name,
                        (unsigned)map->offset);
    for (uint32_t i = map->child; i; i = json->values[i].next) {
        const gsf_json_value* value = &json->values[i];
        gsf__bpe_token token;
        double id = value->number;
        if (decoder) {
            GSF__TRY(gsf__bpe_read_token(file, value, &token));
            id = value->key_size > 0 && value->key_size <= 10 ? 0.0 : -1.0;
            for (uint32_t k = 0; k < value->key_size && id >= 0.0; k++)
                id = value->key[k] >= '0' && value->key[k] <= '9' ? 10.0 * id + (value->key[k] - '0') : -1.0;
        } else {
            memset(&token, 0, sizeof token);
            token.text = value->key;
            token.size = value->key_size;
            token.flags = GSF__BPE_ADDED;
            if (value->type != GSF_JSON_NUMBER || floor(id) != id || token.size == 0) id = -1.0;
        }
        if (!(id >= 0.0) || id >= (double)INT32_MAX)
            return gsf_fail(file->ctx, GSF_ERROR_FORMAT, "%s:%u: not a token with an id from 0 to %d", json->name,
                            (unsigned)value->offset, (int)INT32_MAX - 1);
        token.id = (int32_t)id;
        token.flags |= GSF__BPE_APART;
        GSF__TRY(add(user, &token));
    }
    return GSF_OK;
}

// Marks a token as special; a token that is neither added nor in the vocabulary yet is added with the id *next. `more`:
// it is from additional_special_tokens. The strip flags of an object replace those of the added token, except that
// added_tokens_decoder takes precedence over bos_token and the like.
static gsf_result gsf__bpe_add_special(gsf__bpe_loader* l, const gsf__bpe_token* token, int more, int32_t* next,
                                       int32_t* id) {
    gsf__bpe_tables* t = l->t;
    int32_t i = gsf__bpe_find_added(t, token->text, token->size);
    if (i < 0) {
        gsf__bpe_token fresh = *token;
        const int32_t old = gsf__bpe_find(t, token->text, token->size);
        fresh.id = old >= 0 ? t->tokens[old].id : (*next)++;
        GSF__TRY(gsf__bpe_add(l, &fresh));
        i = t->added_count - 1;
    }
    const int strips = GSF__BPE_LSTRIP | GSF__BPE_RSTRIP;
    int flags = (t->added[i].flags & ~GSF__BPE_APART) | GSF__BPE_SPECIAL;
    if (token->flags & GSF__BPE_OBJECT && (more || !l->decoder)) flags = (flags & ~strips) | (token->flags & strips);
    *id = t->added[i].id;
    t->added[i].flags = flags | (more && *id >= t->vocabulary ? GSF__BPE_APART : 0);
    return GSF_OK;
}

static gsf_result gsf__bpe_add_more_special(gsf__bpe_loader* l, const gsf__nn_config* file, int32_t* next) {
    const gsf_json* json = &file->json;
    const gsf_json_value* list = gsf__nn_config_find(file, "additional_special_tokens");
    if (!list) return GSF_OK;
    if (list->type != GSF_JSON_ARRAY)
        return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s:%u: additional_special_tokens is not an array", json->name,
                        (unsigned)list->offset);
    for (uint32_t i = list->child; i; i = json->values[i].next) {
        gsf__bpe_token token;
        int32_t id;
        GSF__TRY(gsf__bpe_read_token(file, &json->values[i], &token));
        GSF__TRY(gsf__bpe_add_special(l, &token, 1, next, &id));
    }
    return GSF_OK;
}

// As transformers loads it: only tokenizer_config.json if it lists the added tokens, otherwise special_tokens_map.json
// takes precedence over it.
static gsf_result gsf__bpe_read_special(gsf__bpe_loader* l, gsf_nn_bpe* out) {
    static const char* const keys[] = {"bos_token", "eos_token", "unk_token", "sep_token", "pad_token", "cls_token",
                                       "mask_token"};
    gsf__bpe_tables* t = l->t;
    int32_t other, *const ids[GSF__COUNT(keys)] = {&out->bos, &out->eos, &out->unk, &other, &out->pad, &other, &other};
    l->decoder = gsf__nn_config_find(&t->config, "added_tokens_decoder");
    GSF__TRY(gsf__nn_read_added(&t->config, l->decoder, &t->added_tokens, gsf__bpe_add, l));
    int32_t next = t->vocabulary;
    for (int32_t i = 0; i < t->added_count; i++)
        next += gsf__bpe_find(t, t->added[i].text, t->added[i].size) < 0;
    for (size_t i = 0; i < GSF__COUNT(keys); i++) {
        const int mapped = !l->decoder && gsf__nn_config_find(&t->special_map, keys[i]);
        const gsf__nn_config* file = mapped ? &t->special_map : &t->config;
        const gsf_json_value* value = gsf__nn_config_find(file, keys[i]);
        const int given = gsf_find_json_member(&t->config.json, t->config.json.values, keys[i]) != NULL;
        gsf__bpe_token token;
        *ids[i] = -1;
        if (value) {
            GSF__TRY(gsf__bpe_read_token(file, value, &token));
        } else if (i < 3 && !given) { // the default of GPT2Tokenizer
            memset(&token, 0, sizeof token);
            token.text = "<|endoftext|>";
            token.size = strlen(token.text);
            token.flags = GSF__BPE_ADDED;
        } else {
            continue;
        }
        GSF__TRY(gsf__bpe_add_special(l, &token, 0, &next, ids[i]));
    }
    GSF__TRY(gsf__bpe_add_more_special(l, &t->config, &next));
    if (!l->decoder) GSF__TRY(gsf__bpe_add_more_special(l, &t->special_map, &next));
    return GSF_OK;
}

static gsf_result gsf__bpe_read_switches(const gsf__nn_config* file, gsf__bpe_tables* t, gsf_nn_bpe* out) {
    const gsf__nn_key keys[] = {
        GSF__KEY_WORD_IS("errors", "replace", "replace"), GSF__KEY_FLAG_OR("add_bos_token", out->add_bos, 0),
        GSF__KEY_FLAG_OR("add_prefix_space", t->prefix_space, 0),
        GSF__KEY_FLAG_OR("clean_up_tokenization_spaces", t->clean_up, 0),
        GSF__KEY_FLAG_OR("split_special_tokens", t->split_special, 0)};
    return gsf__nn_config_read(file, keys, GSF__COUNT(keys));
}

static gsf_result gsf__bpe_sort_ids(gsf__bpe_loader* l, gsf_nn_bpe* out) {
    gsf__bpe_tables* t = l->t;
    const size_t vocabulary = (size_t)t->vocabulary, added = (size_t)t->added_count, count = vocabulary + added;
    if (added) qsort(t->added, added, sizeof *t->added, gsf__bpe_compare_texts);
    t->by_id = (gsf__bpe_token*)gsf_alloc(l->ctx, count, sizeof *t->by_id);
    if (!t->by_id) return GSF_ERROR_OUT_OF_MEMORY;
    memcpy(t->by_id, t->tokens, vocabulary * sizeof *t->tokens);
    if (added) memcpy(t->by_id + vocabulary, t->added, added * sizeof *t->added);
    qsort(t->by_id, count, sizeof *t->by_id, gsf__bpe_compare_ids);
    t->by_id_count = (int32_t)count;
    for (size_t i = 1; i < count; i++) {
        const gsf__bpe_token *a = &t->by_id[i - 1], *b = &t->by_id[i];
        if (a->id == b->id && (a->flags & GSF__BPE_ADDED) == (b->flags & GSF__BPE_ADDED))
            return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s: tokens %s and %s both have the id %d", l->folder,
                            gsf__nn_show(a->text).text, gsf__nn_show(b->text).text, (int)a->id);
    }
    out->highest_id = t->by_id[count - 1].id;
    return GSF_OK;
}

static gsf_result gsf__bpe_load(gsf__bpe_loader* l, gsf_nn_bpe* out) {
    GSF__TRY(gsf__bpe_unpack_kinds(l->ctx, l->t));
    GSF__TRY(gsf__nn_open_config(l->ctx, l->folder, "tokenizer_config.json", 1, &l->t->config));
    GSF__TRY(gsf__nn_open_config(l->ctx, l->folder, "special_tokens_map.json", 1, &l->t->special_map));
    GSF__TRY(gsf__nn_open_config(l->ctx, l->folder, "added_tokens.json", 1, &l->t->added_tokens));
    GSF__TRY(gsf__bpe_read_switches(&l->t->config, l->t, out));
    GSF__TRY(gsf__bpe_read_vocabulary(l));
    GSF__TRY(gsf__bpe_read_merges(l));
    GSF__TRY(gsf__bpe_read_special(l, out));
    GSF__TRY(gsf__bpe_sort_ids(l, out));
    if (out->add_bos && out->bos < 0)
        return gsf_fail(l->ctx, GSF_ERROR_FORMAT, "%s: add_bos_token is true, but there is no bos_token", l->folder);
    return GSF_OK;
}

GSF_API void gsf_nn_destroy_bpe(gsf_context* ctx, gsf_nn_bpe* bpe) {
    gsf__bpe_tables* t = (gsf__bpe_tables*)bpe->tables;
    if (t) {
        gsf_destroy_json(ctx, &t->config.json);
        gsf_destroy_json(ctx, &t->special_map.json);
        gsf_destroy_json(ctx, &t->added_tokens.json);
        gsf_free(ctx, t->strings);
        gsf_free(ctx, t->tokens);
        gsf_free(ctx, t->added);
        gsf_free(ctx, t->by_id);
        gsf_free(ctx, t->merges);
        gsf_free(ctx, t->first);
        gsf_free(ctx, t->kinds);
    }
    gsf_free(ctx, t);
    memset(bpe, 0, sizeof *bpe);
}

GSF_API gsf_result gsf_nn_load_bpe(gsf_context* ctx, const char* folder, gsf_nn_bpe* out) {
    gsf__bpe_loader l;
    memset(&l, 0, sizeof l);
    memset(out, 0, sizeof *out);
    l.ctx = ctx;
    l.folder = folder;
    l.t = (gsf__bpe_tables*)gsf_alloc_zeroed(ctx, 1, sizeof *l.t);
    out->tables = l.t;
    const gsf_result result = l.t ? gsf__bpe_load(&l, out) : GSF_ERROR_OUT_OF_MEMORY;
    gsf_destroy_buffer(ctx, &l.scratch);
    if (result) gsf_nn_destroy_bpe(ctx, out);
    return result;
}

// ---- encoding

typedef struct gsf__nn_ids { // the result of encoding a text
    int32_t* ids;
    size_t count, capacity;
} gsf__nn_ids;

static gsf_result gsf__nn_emit(gsf_context* ctx, gsf__nn_ids* out, int32_t id) {
    GSF__TRY(gsf__reserve(ctx, (void**)&out->ids, &out->capacity, out->count, out->count + 1, sizeof *out->ids));
    out->ids[out->count++] = id;
    return GSF_OK;
}

typedef struct gsf__bpe_run {
    gsf_context* ctx;
    const gsf__bpe_tables* t;
    int32_t unk;
    gsf__nn_ids out;
    void* scratch;      // per word, see gsf__bpe_place
    size_t word_capacity;
    int32_t *symbols, *before, *after, *found, *batch; // one per byte of a word
    uint64_t* heap;     // rank << 32 | index of the left symbol
    size_t heap_size;
} gsf__bpe_run;

static void gsf__bpe_sift(uint64_t* heap, size_t size, size_t at) { // restores a min-heap downwards from `at`
    const uint64_t value = heap[at];
    for (size_t child; (child = 2 * at + 1) < size; at = child) {
        if (child + 1 < size && heap[child + 1] < heap[child]) child++;
        if (value <= heap[child]) break;
        heap[at] = heap[child];
    }
    heap[at] = value;
}

static void gsf__bpe_push(gsf__bpe_run* run, uint64_t value) {
    size_t at = run->heap_size++;
    for (; at > 0 && value < run->heap[(at - 1) / 2]; at = (at - 1) / 2) run->heap[at] = run->heap[(at - 1) / 2];
    run->heap[at] = value;
}

// Looks up the merge of the symbol at `place` with the next one; returns 1 if there is one.
static int gsf__bpe_look(gsf__bpe_run* run, int32_t place) {
    const gsf__bpe_tables* t = run->t;
    const int32_t left = run->symbols[place], next = run->after[place];
    run->found[place] = -1;
    if (next < 0 || left < 0 || run->symbols[next] < 0) return 0;
    int32_t low = t->first[left], high = t->first[left + 1];
    while (low < high) {
        const int32_t middle = low + (high - low) / 2;
        if (t->merges[middle].right < run->symbols[next]) low = middle + 1;
        else high = middle;
    }
    if (low == t->first[left + 1] || t->merges[low].right != run->symbols[next]) return 0;
    run->found[place] = low;
    return 1;
}

static uint64_t gsf__bpe_key(const gsf__bpe_run* run, int32_t place) {
    return (uint64_t)run->t->merges[run->found[place]].rank << 32 | (uint32_t)place;
}

static void gsf__bpe_merge_at(gsf__bpe_run* run, int32_t place) {
    const int32_t gone = run->after[place], after = run->after[gone], before = run->before[place];
    run->symbols[place] = run->t->merges[run->found[place]].result;
    run->found[gone] = -1;
    run->after[place] = after;
    if (after >= 0) run->before[after] = place;
    if (gsf__bpe_look(run, place)) gsf__bpe_push(run, gsf__bpe_key(run, place));
    if (before >= 0 && gsf__bpe_look(run, before)) gsf__bpe_push(run, gsf__bpe_key(run, before));
}

// Allocates scratch, per byte of a word: 5 32-bit integers and two heap entries, as a merge removes one entry and adds
// at most two.
static gsf_result gsf__bpe_place(gsf__bpe_run* run, size_t size) {
    if (size <= run->word_capacity) return GSF_OK;
    size = size < 64 ? 64 : size;
    gsf_free(run->ctx, run->scratch);
    run->word_capacity = 0;
    run->scratch = gsf_alloc(run->ctx, size, 2 * sizeof(uint64_t) + 5 * sizeof(int32_t));
    if (!run->scratch) return GSF_ERROR_OUT_OF_MEMORY;
    run->word_capacity = size;
    run->heap = (uint64_t*)run->scratch;
    run->symbols = (int32_t*)(void*)(run->heap + 2 * size);
    run->before = run->symbols + size;
    run->after = run->before + size;
    run->found = run->after + size;
    run->batch = run->found + size;
    return GSF_OK;
}

static gsf_result gsf__bpe_word(gsf__bpe_run* run, const char* word, size_t size) {
    const int32_t n = (int32_t)size;
    GSF__TRY(gsf__bpe_place(run, size));
    run->heap_size = 0;
    for (int32_t i = 0; i < n; i++) {
        run->symbols[i] = run->t->bytes[(unsigned char)word[i]];
        run->before[i] = i - 1;
        run->after[i] = i + 1 < n ? i + 1 : -1;
    }
    for (int32_t i = 0; i < n; i++)
        if (gsf__bpe_look(run, i)) run->heap[run->heap_size++] = gsf__bpe_key(run, i);
    for (size_t i = run->heap_size / 2; i-- > 0;) gsf__bpe_sift(run->heap, run->heap_size, i);
    while (run->heap_size) {
        const int32_t rank = (int32_t)(run->heap[0] >> 32);
        int32_t places = 0;
        while (run->heap_size && (int32_t)(run->heap[0] >> 32) == rank) { // popped from left to right
            run->batch[places++] = (int32_t)(run->heap[0] & 0x7fffffffu);
            run->heap[0] = run->heap[--run->heap_size];
            if (run->heap_size) gsf__bpe_sift(run->heap, run->heap_size, 0);
        }
        for (int32_t i = 0; i < places; i++) { // skip pairs changed by an earlier merge of this batch
            const int32_t found = run->found[run->batch[i]];
            if (found >= 0 && run->t->merges[found].rank == rank) gsf__bpe_merge_at(run, run->batch[i]);
        }
    }
    for (int32_t i = 0; i >= 0; i = run->after[i]) {
        const int32_t symbol = run->symbols[i];
        if (symbol < 0 && run->unk < 0)
            return gsf_fail(run->ctx, GSF_ERROR_INVALID_ARGUMENT,
                            "byte 0x%02x of the text is not in this vocabulary", (unsigned)(unsigned char)word[i]);
        GSF__TRY(gsf__nn_emit(run->ctx, &run->out, symbol < 0 ? run->unk : run->t->tokens[symbol].id));
    }
    return GSF_OK;
}

// Size in bytes of the first match of  's|'t|'re|'ve|'m|'ll|'d| ?\p{L}+| ?\p{N}+| ?[^\s\p{L}\p{N}]+|\s+(?!\S)|\s+
static size_t gsf__bpe_next_word(const gsf__bpe_tables* t, const char* text, size_t size) {
    static const char* const endings[] = {"s", "t", "re", "ve", "m", "ll", "d"};
    size_t step, last = 0;
    for (size_t i = 0; text[0] == '\'' && i < GSF__COUNT(endings); i++) {
        const size_t length = strlen(endings[i]);
        if (size > length && memcmp(text + 1, endings[i], length) == 0) return 1 + length;
    }
    size_t at = text[0] == ' ' && size > 1;
    const int kind = gsf__bpe_kind(t, text + at, size - at, &step);
    if (kind == GSF__BPE_SPACE) at = 0;
    while (at < size && gsf__bpe_kind(t, text + at, size - at, &step) == kind) {
        last = at;
        at += step;
    }
    // The last of several spaces before a word is left for the next match, which may include it.
    return kind == GSF__BPE_SPACE && at < size && last > 0 ? last : at;
}

static gsf_result gsf__bpe_piece(gsf__bpe_run* run, const char* text, size_t size) { // text without added tokens
    while (size) {
        const size_t word = gsf__bpe_next_word(run->t, text, size);
        GSF__TRY(gsf__bpe_word(run, text, word));
        text += word;
        size -= word;
    }
    return GSF_OK;
}

// The longest added token that is a prefix of `text`, or NULL. As they are sorted, those that match the bytes so far
// are contiguous, the shortest first.
static const gsf__bpe_token* gsf__bpe_match(const gsf__bpe_tables* t, const char* text, size_t left) {
    const gsf__bpe_token* best = NULL;
    int32_t low = 0, high = t->added_count;
    for (size_t d = 0; low < high; d++) {
        if (t->added[low].size == d) best = &t->added[low++];
        if (d == left) break;
        for (int side = 0; side < 2; side++) { // narrow to those with text[d] next: lower, then upper bound
            int32_t a = low, b = high;
            while (a < b) {
                const int32_t middle = a + (b - a) / 2;
                const int order = (unsigned char)t->added[middle].text[d] - (unsigned char)text[d];
                if (order < 0 || (side && order == 0)) a = middle + 1;
                else b = middle;
            }
            if (side) high = a;
            else low = a;
        }
    }
    return best;
}

static gsf_result gsf__bpe_text(gsf__bpe_run* run, const char* text, size_t size) {
    const gsf__bpe_tables* t = run->t;
    size_t start = 0;
    int strip = 0; // the previous token also consumes the white space after it
    for (size_t at = 0; at <= size; at++) {
        const gsf__bpe_token* token = at < size && !t->split_special ? gsf__bpe_match(t, text + at, size - at) : NULL;
        if (!token && at < size) continue;
        size_t end = at;
        gsf__bpe_strip(t, text, strip, token && token->flags & GSF__BPE_LSTRIP, &start, &end);
        GSF__TRY(gsf__bpe_piece(run, text + start, end - start));
        if (!token) break;
        GSF__TRY(gsf__nn_emit(run->ctx, &run->out, token->id));
        start = at + token->size;
        at = start - 1;
        strip = token->flags & GSF__BPE_RSTRIP;
    }
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_encode_bpe(gsf_context* ctx, const gsf_nn_bpe* bpe, const char* text, size_t size,
                                     int32_t no_bos, int32_t** ids, size_t* count) {
    gsf__bpe_run run;
    memset(&run, 0, sizeof run);
    run.ctx = ctx;
    run.t = (const gsf__bpe_tables*)bpe->tables;
    run.unk = bpe->unk;
    *ids = NULL;
    *count = 0;
    if (size > INT32_MAX / 2) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "a text of %zu bytes", size);
    if (!size) text = "";
    for (size_t i = 0, step; i < size; i += step) {
        step = gsf__utf8_size(text + i, size - i);
        if (!step) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "text:%zu: byte 0x%02x is not valid UTF-8", i,
                                   (unsigned)(unsigned char)text[i]);
    }
    gsf_result result = gsf__reserve(ctx, (void**)&run.out.ids, &run.out.capacity, 0, 16, sizeof *run.out.ids);
    if (!result && bpe->add_bos && !no_bos) result = gsf__nn_emit(ctx, &run.out, bpe->bos);
    if (!result && run.t->prefix_space) {
        gsf_buffer spaced;
        memset(&spaced, 0, sizeof spaced);
        gsf_append_bytes(ctx, &spaced, " ", 1);
        gsf_append_bytes(ctx, &spaced, text, size);
        result = spaced.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf__bpe_text(&run, spaced.data, spaced.size);
        gsf_destroy_buffer(ctx, &spaced);
    } else if (!result) {
        result = gsf__bpe_text(&run, text, size);
    }
    gsf_free(ctx, run.scratch);
    if (result) gsf_free(ctx, run.out.ids);
    if (result) return result;
    *ids = run.out.ids;
    *count = run.out.count;
    return GSF_OK;
}

// ---- decoding

// Appends bytes as UTF-8, with U+FFFD for each maximal invalid part, as Python's errors="replace" does.
static void gsf__bpe_append_replaced(gsf_context* ctx, gsf_buffer* out, const char* text, size_t size) {
    const unsigned char* p = (const unsigned char*)text;
    for (size_t i = 0; i < size;) {
        size_t step, good = i;
        while (good < size && (step = gsf__utf8_size(text + good, size - good)) != 0) good += step;
        if (good > i) gsf_append_bytes(ctx, out, text + i, good - i);
        i = good;
        if (i == size) break;
        const unsigned c = p[i++];
        const unsigned low = c == 0xe0 ? 0xa0 : c == 0xf0 ? 0x90 : 0x80, high = c == 0xed ? 0x9f : c == 0xf4 ? 0x8f : 0xbf;
        // continuation bytes a truncated character may have
        const size_t more = c >= 0xf0 && c <= 0xf4 ? 2 : c >= 0xe0 && c <= 0xef;
        for (size_t k = 0; k < more && i < size; k++, i++)
            if (k == 0 ? p[i] < low || p[i] > high : (p[i] & 0xc0) != 0x80) break;
        gsf_append_bytes(ctx, out, "\xef\xbf\xbd", 3);
    }
}

// Appends the bytes that a vocabulary token spells.
static void gsf__bpe_append_bytes(gsf_context* ctx, gsf_buffer* out, const gsf__bpe_token* token) {
    for (size_t i = 0, step; i < token->size; i += step) {
        step = gsf__utf8_size(token->text + i, token->size - i);
        const int byte = gsf__bpe_byte(gsf__bpe_load_character(token->text + i, step));
        const char c = (char)byte;
        gsf_append_bytes(ctx, out, byte < 0 ? token->text + i : &c, byte < 0 ? step : 1);
    }
}

// Replaces every `from` after `start` by `to`, which must not be longer.
static void gsf__bpe_replace(gsf_buffer* text, size_t start, const char* from, const char* to) {
    const size_t from_size = strlen(from), to_size = strlen(to);
    size_t end = start;
    for (size_t i = start; i < text->size;) {
        if (text->size - i >= from_size && memcmp(text->data + i, from, from_size) == 0) {
            memcpy(text->data + end, to, to_size);
            end += to_size;
            i += from_size;
        } else {
            text->data[end++] = text->data[i++];
        }
    }
    text->size = end;
    if (text->data) text->data[end] = 0;
}

static void gsf__bpe_flush(gsf_context* ctx, gsf_buffer* bytes, gsf_buffer* out, int* parts) {
    if (!bytes->size) return;
    if ((*parts)++) gsf_append_bytes(ctx, out, " ", 1);
    gsf__bpe_append_replaced(ctx, out, bytes->data, bytes->size);
    bytes->size = 0;
}

GSF_API gsf_result gsf_nn_decode_bpe(gsf_context* ctx, const gsf_nn_bpe* bpe, const int32_t* ids, size_t count,
                                     int32_t skip_special, gsf_buffer* out) {
    static const char* const tidy[][2] = {{" .", "."}, {" ?", "?"}, {" !", "!"}, {" ,", ","}, {" ' ", "'"},
                                          {" n't", "n't"}, {" 'm", "'m"}, {" 's", "'s"}, {" 've", "'ve"}, {" 're", "'re"}};
    const gsf__bpe_tables* t = (const gsf__bpe_tables*)bpe->tables;
    const size_t start = out->size;
    gsf_buffer bytes;
    int parts = 0;
    memset(&bytes, 0, sizeof bytes);
    gsf_append_bytes(ctx, out, "", 0);
    for (size_t i = 0; i < count; i++) {
        const int32_t at = gsf__bpe_find_id(t, ids[i]);
        if (at == t->by_id_count || t->by_id[at].id != ids[i]) continue;
        const gsf__bpe_token* token = &t->by_id[at];
        if (skip_special && token->flags & GSF__BPE_SPECIAL) continue;
        if (token->flags & GSF__BPE_APART) {
            gsf__bpe_flush(ctx, &bytes, out, &parts);
            if (parts++) gsf_append_bytes(ctx, out, " ", 1);
            gsf_append_bytes(ctx, out, token->text, token->size);
        } else {
            gsf__bpe_append_bytes(ctx, &bytes, token);
        }
    }
    gsf__bpe_flush(ctx, &bytes, out, &parts);
    const int failed = bytes.failed || out->failed;
    gsf_destroy_buffer(ctx, &bytes);
    if (failed) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; t->clean_up && i < GSF__COUNT(tidy); i++) gsf__bpe_replace(out, start, tidy[i][0], tidy[i][1]);
    return GSF_OK;
}

// ---- >>nn captioner -------------------------------------------------------------
//
// BLIP-2 (Li et al. 2023) with OPT (Zhang et al. 2022): a vision transformer, learned queries that attend to its tokens
// (Q-Former), a projection of the queries to token embeddings of the language model, and the language model, which
// continues them. Follows transformers 4.51.3: models/blip_2/modeling_blip_2.py, models/opt/modeling_opt.py,
// image_processing_blip.py.

typedef struct gsf__qformer_attention {
    gsf__nn_layer q, k, v, out, norm;
} gsf__qformer_attention;

typedef struct gsf__qformer_layer {
    gsf__qformer_attention self, cross; // cross.q.weight NULL: no cross-attention
    gsf__nn_layer up, down, norm;
} gsf__qformer_layer;

typedef struct gsf__qformer {
    int64_t queries, width, mlp, layers, cross_every; // every cross_every-th layer has cross-attention to the image
    int32_t heads;
    float eps;
    gsf__nn_activation activation;
    int text_input;                                   // the file also holds tensors for text input, which are ignored
    const gsf_nn_tensor* tokens;
    gsf__nn_layer norm;
    gsf__qformer_layer* all;
} gsf__qformer;

typedef struct gsf__opt {
    gsf__nn_block_sizes sizes;
    int64_t layers, vocabulary, positions;
    int own_head, no_final_norm;
    const gsf_nn_tensor *tokens, *places;
    gsf__nn_layer norm, head;
    gsf__nn_block* blocks;
} gsf__opt;

typedef struct gsf__blip { // pointed to by gsf_nn_captioner.nets
    int64_t image_size;
    gsf_resize_filter filter;
    double rescale;
    float mean[3], deviation[3];
    gsf__vit vision;
    gsf__qformer qformer;
    gsf__nn_layer projection;
    gsf__opt text;
} gsf__blip;

// rows of OPT's position table before position 0; default caption length
enum { GSF__OPT_OFFSET = 2, GSF__CAPTION_TOKENS = 20 };
static const float gsf__opt_eps = 1e-5f;                // PyTorch's default; OPT's config has no key for it

// ---- captioner: configuration

// Fails unless `heads` divides `width`.
static gsf_result gsf__blip_check_heads(const gsf__nn_config* file, int64_t width, int32_t heads) {
    if (width % heads == 0) return GSF_OK;
    return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s: %d heads do not divide hidden_size %lld", file->json.name,
                    (int)heads, (long long)width);
}

static gsf_result gsf__blip_read_vision(const gsf__nn_config* file, gsf__blip* net) {
    gsf__vit* vit = &net->vision;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT_OR("hidden_size", vit->sizes.width, 1408, 1, 65536),
        GSF__KEY_INT_OR("intermediate_size", vit->sizes.mlp, 6144, 1, 1 << 20),
        GSF__KEY_INT_OR("num_hidden_layers", vit->layers, 39, 1, 1024),
        GSF__KEY_INT_OR("num_attention_heads", vit->sizes.heads, 16, 1, 1024),
        GSF__KEY_INT_OR("image_size", net->image_size, 224, 1, 1 << 14),
        GSF__KEY_INT_OR("patch_size", vit->patch, 14, 1, 1024),
        GSF__KEY_REAL_OR("layer_norm_eps", vit->sizes.eps, 1e-6, 1e-15, 1.0),
        GSF__KEY_FLAG_OR("qkv_bias", vit->sizes.qkv_bias, 1),
        GSF__KEY_ACTIVATION_OR("hidden_act", vit->sizes.activation, "gelu")};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    GSF__TRY(gsf__blip_check_heads(file, vit->sizes.width, vit->sizes.heads));
    if (net->image_size < vit->patch)
        return gsf_fail(file->ctx, GSF_ERROR_FORMAT, "%s: patch_size %lld is above image_size %lld", file->json.name,
                        (long long)vit->patch, (long long)net->image_size);
    vit->sizes.head_dim = (int32_t)(vit->sizes.width / vit->sizes.heads);
    vit->channels = 3;
    vit->grid = net->image_size / vit->patch;
    vit->block_names = "vision_model.encoder.layers.";
    vit->prefix = "vision_model.embeddings.";
    return GSF_OK;
}

static gsf_result gsf__blip_read_qformer(const gsf__nn_config* file, gsf__blip* net) {
    gsf__qformer* q = &net->qformer;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT_OR("hidden_size", q->width, 768, 1, 65536),
        GSF__KEY_INT_OR("intermediate_size", q->mlp, 3072, 1, 1 << 20),
        GSF__KEY_INT_OR("num_hidden_layers", q->layers, 12, 1, 1024),
        GSF__KEY_INT_OR("num_attention_heads", q->heads, 12, 1, 1024),
        GSF__KEY_INT_OR("cross_attention_frequency", q->cross_every, 2, 1, 1024),
        GSF__KEY_REAL_OR("layer_norm_eps", q->eps, 1e-12, 1e-15, 1.0),
        GSF__KEY_FLAG_OR("use_qformer_text_input", q->text_input, 0),
        GSF__KEY_ACTIVATION_OR("hidden_act", q->activation, "gelu"),
        GSF__KEY_WORD_IS("position_embedding_type", "absolute", "absolute")};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    return gsf__blip_check_heads(file, q->width, q->heads);
}

static gsf_result gsf__blip_read_text(const gsf__nn_config* file, gsf__blip* net, gsf_nn_captioner* out) {
    gsf__opt* opt = &net->text;
    int64_t words;
    int tied;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT_OR("hidden_size", opt->sizes.width, 768, 1, 65536),
        GSF__KEY_INT_OR("ffn_dim", opt->sizes.mlp, 3072, 1, 1 << 20),
        GSF__KEY_INT_OR("num_hidden_layers", opt->layers, 12, 1, 1024),
        GSF__KEY_INT_OR("num_attention_heads", opt->sizes.heads, 12, 1, 1024),
        GSF__KEY_INT_OR("vocab_size", opt->vocabulary, 50272, 1, 1 << 24),
        GSF__KEY_INT_OR("max_position_embeddings", opt->positions, 2048, 1, 1 << 20),
        GSF__KEY_INT_OR("eos_token_id", out->eos, 2, 0, INT32_MAX), GSF__KEY_FLAG_OR("tie_word_embeddings", tied, 1),
        GSF__KEY_FLAG_OR("_remove_final_layer_norm", opt->no_final_norm, 0),
        GSF__KEY_ACTIVATION_OR("activation_function", opt->sizes.activation, "relu"),
        GSF__KEY_WORD_IS("model_type", "opt", "opt"), GSF__KEY_FLAG_IS("do_layer_norm_before", 1, 1),
        GSF__KEY_FLAG_IS("enable_bias", 1, 1), GSF__KEY_FLAG_IS("layer_norm_elementwise_affine", 1, 1)};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    const gsf__nn_key bos = GSF__KEY_INT_OR("bos_token_id", out->bos, 2, 0, (double)(opt->vocabulary - 1));
    GSF__TRY(gsf__nn_config_read_key(file, &bos));
    GSF__TRY(gsf__blip_check_heads(file, opt->sizes.width, opt->sizes.heads));
    opt->sizes.head_dim = (int32_t)(opt->sizes.width / opt->sizes.heads);
    opt->sizes.eps = gsf__opt_eps;
    opt->sizes.qkv_bias = 1;
    opt->own_head = !tied;
    GSF__TRY(gsf__nn_config_int_or(file, "word_embed_proj_dim", opt->sizes.width, 1, 65536, &words));
    if (words == opt->sizes.width) return GSF_OK;
    return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s: word_embed_proj_dim %lld is not hidden_size %lld",
                    file->json.name, (long long)words, (long long)opt->sizes.width);
}

static gsf_result gsf__blip_read_config(const gsf__nn_config* file, void* network) {
    gsf_nn_captioner* out = (gsf_nn_captioner*)network;
    gsf__blip* net = (gsf__blip*)out->nets;
    gsf__nn_config part;
    const gsf__nn_key keys[] = {GSF__KEY_INT_OR("num_query_tokens", net->qformer.queries, 32, 1, 1 << 16),
                                GSF__KEY_INT_OR("image_token_index", out->image_token, -1, 0, INT32_MAX)};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    GSF__TRY(gsf__nn_config_part(file, "vision_config", &part));
    GSF__TRY(gsf__blip_read_vision(&part, net));
    GSF__TRY(gsf__nn_config_part(file, "qformer_config", &part));
    GSF__TRY(gsf__blip_read_qformer(&part, net));
    GSF__TRY(gsf__nn_config_part(file, "text_config", &part));
    return gsf__blip_read_text(&part, net, out);
}

// Reads three numbers, or one for all channels.
static gsf_result gsf__blip_read_colour(const gsf__nn_config* file, const char* key, const float fallback[3], double low,
                                        float out[3]) {
    const gsf_json_value* value = gsf__nn_config_find(file, key);
    for (size_t i = 0; i < 3; i++) {
        const gsf_json_value* number =
            value && value->type == GSF_JSON_ARRAY && value->count == 3 ? gsf_find_json_element(&file->json, value,
                                                                                                i) : value;
        out[i] = fallback[i];
        if (!number) continue;
        if (number->type != GSF_JSON_NUMBER || !(number->number >= low) || !(number->number <= 1e6))
            return gsf__nn_config_fail(file, value, key, "a number or three");
        out[i] = (float)number->number;
    }
    return GSF_OK;
}

static gsf_result gsf__blip_read_processor(const gsf__nn_config* file, gsf__blip* net) {
    static const float mean[3] = {0.48145466f, 0.4578275f, 0.40821073f};
    static const float deviation[3] = {0.26862954f, 0.26130258f, 0.27577711f};
    static const gsf_resize_filter filters[] = {GSF_RESIZE_PIL_LANCZOS, GSF_RESIZE_PIL_BILINEAR, GSF_RESIZE_PIL_BICUBIC};
    int64_t filter; // PIL's enum value
    const gsf__nn_key keys[] = {
        GSF__KEY_FLAG_IS("do_resize", 1, 1), GSF__KEY_FLAG_IS("do_rescale", 1, 1), GSF__KEY_FLAG_IS("do_normalize", 1, 1),
        GSF__KEY_FLAG_IS("do_convert_rgb", 1, 1), GSF__KEY_INT_OR("resample", filter, 3, 1, 3),
        GSF__KEY_REAL_OR("rescale_factor", net->rescale, 1.0 / 255.0, 1e-9, 1e9)};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    net->filter = filters[filter - 1];
    GSF__TRY(gsf__blip_read_colour(file, "image_mean", mean, -1e6, net->mean));
    GSF__TRY(gsf__blip_read_colour(file, "image_std", deviation, 1e-6, net->deviation));
    const gsf_json_value* size = gsf__nn_config_find(file, "size");
    double sides[2] = {384.0, 384.0};
    for (int i = 0; i < 2 && size; i++) {
        const gsf_json_value* side =
            size->type == GSF_JSON_OBJECT ? gsf_find_json_member(&file->json, size, i ? "width" : "height") : size;
        if (!side || side->type != GSF_JSON_NUMBER)
            return gsf__nn_config_fail(file, size, "size", "a number, or an object with height and width");
        sides[i] = side->number;
    }
    if (sides[0] == (double)net->image_size && sides[1] == sides[0]) return GSF_OK;
    return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s: images of %g x %g for a model of %lld x %lld", file->json.name,
                    sides[1], sides[0], (long long)net->image_size, (long long)net->image_size);
}

// ---- captioner: tables of tensors

static const gsf__nn_entry gsf__blip_block_entries[] = { // below vision_model.encoder.layers.N.
    {"layer_norm1", "d", GSF__NN_BLOCK(norm1)},
    {"self_attn.qkv", "td", GSF__NN_BLOCK_AS(qkv, GSF__NN_BIASED, 'b')},
    {"self_attn.projection", "dd", GSF__NN_BLOCK(out)},
    {"layer_norm2", "d", GSF__NN_BLOCK(norm2)},
    {"mlp.fc1", "md", GSF__NN_BLOCK(up)},
    {"mlp.fc2", "dm", GSF__NN_BLOCK(down)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__opt_block_entries[] = { // below language_model.model.decoder.layers.N.
    {"self_attn_layer_norm", "d", GSF__NN_BLOCK(norm1)},
    {"self_attn.q_proj", "dd", GSF__NN_BLOCK(q)},
    {"self_attn.k_proj", "dd", GSF__NN_BLOCK(k)},
    {"self_attn.v_proj", "dd", GSF__NN_BLOCK(v)},
    {"self_attn.out_proj", "dd", GSF__NN_BLOCK(out)},
    {"final_layer_norm", "d", GSF__NN_BLOCK(norm2)},
    {"fc1", "md", GSF__NN_BLOCK(up)},
    {"fc2", "dm", GSF__NN_BLOCK(down)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__blip_vision_entries[] = { // below vision_model.
    {"embeddings.class_embedding", "11d", GSF__VIT_TENSOR(class_token)},
    {"embeddings.position_embedding", "1sd", GSF__VIT_TENSOR(positions)},
    {"embeddings.patch_embedding", "dcpp", GSF__NN_AT(gsf__vit, patches)},
    {"post_layernorm", "d", GSF__NN_AT(gsf__vit, norm)},
    GSF__NN_END,
};

// Letters: d width, m MLP, e width of the vision tokens, x 0 if the layer has no cross-attention.
#define GSF__QFORMER_AT(member) offsetof(gsf__qformer_layer, member), GSF__NN_PAIR
static const gsf__nn_entry gsf__qformer_layer_entries[] = { // below qformer.encoder.layer.N.
    {"attention.attention.query", "dd", GSF__QFORMER_AT(self.q), 0},
    {"attention.attention.key", "dd", GSF__QFORMER_AT(self.k), 0},
    {"attention.attention.value", "dd", GSF__QFORMER_AT(self.v), 0},
    {"attention.output.dense", "dd", GSF__QFORMER_AT(self.out), 0},
    {"attention.output.LayerNorm", "d", GSF__QFORMER_AT(self.norm), 0},
    {"crossattention.attention.query", "dd", GSF__QFORMER_AT(cross.q), 'x'},
    {"crossattention.attention.key", "de", GSF__QFORMER_AT(cross.k), 'x'},
    {"crossattention.attention.value", "de", GSF__QFORMER_AT(cross.v), 'x'},
    {"crossattention.output.dense", "dd", GSF__QFORMER_AT(cross.out), 'x'},
    {"crossattention.output.LayerNorm", "d", GSF__QFORMER_AT(cross.norm), 'x'},
    {"intermediate_query.dense", "md", GSF__QFORMER_AT(up), 0},
    {"output_query.dense", "dm", GSF__QFORMER_AT(down), 0},
    {"output_query.LayerNorm", "d", GSF__QFORMER_AT(norm), 0},
    GSF__NN_END,
};
#undef GSF__QFORMER_AT

// Letters: d width of the language model, e width of the Q-Former, q queries, v vocabulary, s rows of the position
// table, h 0 if the head is tied to the token embeddings, n 0 without a final norm.
static const gsf__nn_entry gsf__blip_entries[] = {
    {"query_tokens", "1qe", offsetof(gsf__blip, qformer.tokens), GSF__NN_TENSOR, 0},
    {"qformer.layernorm", "e", GSF__NN_AT(gsf__blip, qformer.norm)},
    {"language_projection", "de", GSF__NN_AT(gsf__blip, projection)},
    {"language_model.model.decoder.embed_tokens", "vd", offsetof(gsf__blip, text.tokens), GSF__NN_WEIGHT, 0},
    {"language_model.model.decoder.embed_positions", "sd", offsetof(gsf__blip, text.places), GSF__NN_WEIGHT, 0},
    {"language_model.model.decoder.final_layer_norm", "d", offsetof(gsf__blip, text.norm), GSF__NN_PAIR, 'n'},
    {"language_model.lm_head", "vd", offsetof(gsf__blip, text.head), GSF__NN_WEIGHT, 'h'},
    GSF__NN_END,
};

static gsf__nn_sizes gsf__blip_sizes(const gsf__blip* net) {
    const gsf__opt* opt = &net->text;
    const gsf__nn_sizes sizes = {{{'d', opt->sizes.width}, {'e', net->qformer.width}, {'q', net->qformer.queries},
                                  {'v', opt->vocabulary}, {'s', opt->positions + GSF__OPT_OFFSET}, {'h', opt->own_head},
                                  {'n', !opt->no_final_norm}}};
    return sizes;
}

// Sizes of layer `index` of the Q-Former.
static gsf__nn_sizes gsf__qformer_sizes(const gsf__blip* net, int64_t index) {
    const gsf__qformer* q = &net->qformer;
    const gsf__nn_sizes sizes = {{{'d', q->width}, {'m', q->mlp}, {'e', net->vision.sizes.width},
                                  {'x', index % q->cross_every == 0}}};
    return sizes;
}

static gsf_result gsf__qformer_bind(gsf__nn_loader* loader, gsf__blip* net) {
    gsf__qformer* q = &net->qformer;
    q->all = (gsf__qformer_layer*)gsf_alloc_zeroed(loader->ctx, (size_t)q->layers, sizeof *q->all);
    if (!q->all) return GSF_ERROR_OUT_OF_MEMORY;
    for (int64_t i = 0; i < q->layers; i++) {
        const gsf__nn_sizes sizes = gsf__qformer_sizes(net, i);
        char prefix[64], unused[96];
        snprintf(prefix, sizeof prefix, "qformer.encoder.layer.%lld.", (long long)i);
        GSF__TRY(gsf__nn_bind(loader, &sizes, gsf__qformer_layer_entries, prefix, &q->all[i]));
        for (int k = 0; k < 2 && q->text_input; k++) {
            snprintf(unused, sizeof unused, "%s%s", prefix, k ? "output." : "intermediate.");
            gsf__nn_ignore(loader, unused);
        }
    }
    if (q->text_input) gsf__nn_ignore(loader, "embeddings.");
    return GSF_OK;
}

static gsf_result gsf__blip_bind(gsf__nn_loader* loader, void* network) {
    gsf__blip* net = (gsf__blip*)((gsf_nn_captioner*)network)->nets;
    gsf__opt* opt = &net->text;
    const gsf__nn_sizes sizes = gsf__blip_sizes(net);
    GSF__TRY(gsf__vit_bind(loader, gsf__blip_vision_entries, gsf__blip_block_entries, "vision_model.", &net->vision));
    net->vision.register_tokens = net->vision.class_token; // never read, as there are 0 registers
    GSF__TRY(gsf__nn_bind(loader, &sizes, gsf__blip_entries, "", net));
    GSF__TRY(gsf__qformer_bind(loader, net));
    if (!opt->own_head) {
        opt->head.weight = opt->tokens;
        gsf__nn_ignore(loader, "language_model.lm_head."); // tied to the token embeddings
    }
    return gsf__nn_bind_blocks(loader, &opt->sizes, gsf__opt_block_entries, "language_model.model.decoder.layers.",
                                opt->layers, &opt->blocks);
}

GSF_API void gsf_nn_destroy_captioner(gsf_context* ctx, gsf_nn_captioner* captioner) {
    gsf__blip* net = (gsf__blip*)captioner->nets;
    if (net) {
        gsf_free(ctx, net->vision.blocks);
        gsf_free(ctx, net->qformer.all);
        gsf_free(ctx, net->text.blocks);
    }
    gsf_free(ctx, net);
    gsf_nn_destroy_bpe(ctx, &captioner->tokenizer);
    gsf_nn_destroy_weights(ctx, &captioner->weights);
    memset(captioner, 0, sizeof *captioner);
}

GSF_API gsf_result gsf_nn_load_captioner(gsf_context* ctx, const char* folder, gsf_nn_captioner* out) {
    gsf__nn_config file;
    memset(out, 0, sizeof *out);
    gsf__blip* net = (gsf__blip*)gsf_alloc_zeroed(ctx, 1, sizeof *net);
    if (!net) return GSF_ERROR_OUT_OF_MEMORY;
    out->nets = net;
    gsf_result result = gsf__nn_open_network(ctx, folder, "model", gsf__blip_read_config, gsf__blip_bind, out, &out->weights);
    if (!result) {
        result = gsf__nn_open_config(ctx, folder, "preprocessor_config.json", 0, &file);
        if (!result) result = gsf__blip_read_processor(&file, net);
        gsf__nn_close_config(&file);
    }
    if (!result) result = gsf_nn_load_bpe(ctx, folder, &out->tokenizer);
    out->image_size = (int32_t)net->image_size;
    out->query_tokens = (int32_t)net->qformer.queries;
    out->vocabulary = (int32_t)net->text.vocabulary;
    out->positions = (int32_t)net->text.positions;
    if (result) gsf_nn_destroy_captioner(ctx, out);
    return result;
}

// ---- captioner: from the image to embedded queries

typedef struct gsf__nn_caption_desc {
    const gsf_image* image;
    const char* prompt;     // or NULL
    int32_t max_new_tokens; // 0: the default of gsf_nn_caption_image
    const gsf__nn_tap* _tap; // private
} gsf__nn_caption_desc;

typedef struct gsf__caption_run {
    gsf__nn_run nn;
    const gsf_nn_captioner* captioner;
    const gsf__blip* net;
    const gsf__nn_caption_desc* desc;
} gsf__caption_run;

// Resizes the image as PIL does and normalizes it to floats (3, image_size, image_size).
static gsf_result gsf__blip_pixels(gsf_context* ctx, const gsf__blip* net, const gsf_image* image, float* out) {
    const int64_t side = net->image_size;
    gsf_image coloured, small;
    memset(&coloured, 0, sizeof coloured);
    memset(&small, 0, sizeof small);
    const int ready = image->dtype == GSF_U8 && image->channels == 3;
    gsf_result result = gsf_make_image(ctx, GSF_U8, side, side, 3, &small);
    if (!result && !ready) result = gsf_make_image(ctx, GSF_U8, image->width, image->height, 3, &coloured);
    if (!result && !ready) result = gsf_convert_image(ctx, image, &coloured);
    if (!result) result = gsf_resize_image(ctx, ready ? image : &coloured, net->filter, &small);
    for (int64_t y = 0; y < side && !result; y++)
        for (int64_t x = 0; x < side; x++)
            for (int64_t c = 0; c < 3; c++) {
                const uint8_t v = ((const uint8_t*)small.data)[(y * side + x) * 3 + c];
                out[(c * side + y) * side + x] = ((float)((double)v * net->rescale) - net->mean[c]) / net->deviation[c];
            }
    gsf_destroy_image(ctx, &coloured);
    gsf_destroy_image(ctx, &small);
    return result;
}

// Vision tokens of the image: out (1 + patches, width), after the final norm.
static gsf_result gsf__blip_look(gsf__caption_run* run, const float* pixels, float* out) {
    const gsf__vit* vit = &run->net->vision;
    const gsf__nn_tap* tap = run->nn.tap;
    gsf_nn_encoder_desc in;
    gsf__vit_plan plan;
    float* memory = NULL;
    memset(&in, 0, sizeof in);
    in.pixels = pixels;
    in.images = 1;
    in.height = in.width = (int32_t)run->net->image_size;
    run->nn.tap = NULL; // only the final result is shown
    gsf_result result = gsf__vit_open_run(&run->nn, vit, NULL, &in, &plan, &memory);
    if (!result) result = gsf__vit_forward(&run->nn, vit, &in, 0, 1, plan.positions, plan.x);
    if (!result) {
        static const char name[] = "vision_model.post_layernorm.";
        gsf__nn_norm(&run->nn, &vit->norm, vit->sizes.eps, plan.x, plan.tokens, out);
        result = gsf__nn_check(&run->nn, name, name, out, plan.tokens * vit->sizes.width);
    }
    run->nn.tap = tap;
    if (!result) gsf__nn_reveal(&run->nn, out, 0, 1, plan.tokens, vit->sizes.width, "vision");
    gsf_free(run->nn.ctx, memory);
    return result;
}

// x (queries, width) = norm(x + dense(h)), in place.
static gsf_result gsf__qformer_add(gsf__caption_run* run, const float* h, const gsf__nn_layer* dense,
                                   const gsf__nn_layer* norm, float* x) {
    const gsf__qformer* q = &run->net->qformer;
    GSF__TRY(gsf__nn_add(&run->nn, dense, NULL, h, q->queries, x));
    gsf__nn_norm(&run->nn, norm, q->eps, x, q->queries, x);
    return GSF_OK;
}

// Updates the queries x by attention to `rows` rows of `from`. scratch: q (queries, width), then k and v (rows, width).
static gsf_result gsf__qformer_attend(gsf__caption_run* run, const gsf__qformer_attention* a, const float* from,
                                      int64_t rows, float* scratch, float* x) {
    const gsf__qformer* q = &run->net->qformer;
    const int64_t d = q->width;
    float *k = scratch + q->queries * d, *v = k + rows * d;
    GSF__TRY(gsf__nn_linear(&run->nn, &a->q, GSF__NN_LINEAR, x, q->queries, scratch, 0));
    GSF__TRY(gsf__nn_linear(&run->nn, &a->k, GSF__NN_LINEAR, from, rows, k, 0));
    GSF__TRY(gsf__nn_linear(&run->nn, &a->v, GSF__NN_LINEAR, from, rows, v, 0));
    gsf__nn_attention_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.queries = q->queries;
    desc.keys = rows;
    desc.heads = q->heads;
    desc.head_dim = (int32_t)(d / q->heads);
    desc.q = desc.out = scratch;
    desc.k = k;
    desc.v = v;
    GSF__TRY(gsf__nn_attend(&run->nn, &desc, 1));
    return gsf__qformer_add(run, scratch, &a->out, &a->norm, x);
}

static size_t gsf__qformer_floats(const gsf__blip* net) { // x; scratch; two vectors
    const gsf__qformer* q = &net->qformer;
    const size_t d = (size_t)q->width, n = (size_t)q->queries, seen = (size_t)(net->vision.grid * net->vision.grid + 1);
    const size_t attention = n * d + 2 * (seen > n ? seen : n) * d, hidden = n * (size_t)q->mlp;
    return n * d + (attention > hidden ? attention : hidden) + 2 * d;
}

static gsf_result gsf__qformer_layers(gsf__caption_run* run, const float* image, float* scratch, float* x, float* out) {
    const gsf__qformer* q = &run->net->qformer;
    const int64_t d = q->width, seen = run->net->vision.grid * run->net->vision.grid + 1, words = run->net->text.sizes.width;
    gsf_nn_convert_tensor(q->tokens, 0, q->queries * d, x);
    gsf__nn_norm(&run->nn, &q->norm, q->eps, x, q->queries, x);
    GSF__TRY(gsf__nn_check(&run->nn, "query_tokens", "query_tokens", x, q->queries * d));
    for (int64_t i = 0; i < q->layers; i++) {
        const gsf__qformer_layer* l = &q->all[i];
        GSF__TRY(gsf__qformer_attend(run, &l->self, x, q->queries, scratch, x));
        if (l->cross.q.weight) GSF__TRY(gsf__qformer_attend(run, &l->cross, image, seen, scratch, x));
        GSF__TRY(gsf__nn_linear(&run->nn, &l->up, q->activation, x, q->queries, scratch, 0));
        GSF__TRY(gsf__qformer_add(run, scratch, &l->down, &l->norm, x));
        GSF__TRY(gsf__nn_end_block(&run->nn, "qformer.encoder.layer.", i, x, q->queries * d));
    }
    gsf__nn_reveal(&run->nn, x, 0, 1, q->queries, d, "qformer");
    GSF__TRY(gsf__nn_linear(&run->nn, &run->net->projection, GSF__NN_LINEAR, x, q->queries, out, 0));
    GSF__TRY(gsf__nn_check(&run->nn, "language_projection.", "language_projection.", out, q->queries * words));
    gsf__nn_reveal(&run->nn, out, 0, 1, q->queries, words, "projection");
    return GSF_OK;
}

// Lets the queries attend to the vision tokens and projects them to the language model: out (queries, text width).
static gsf_result gsf__qformer_ask(gsf__caption_run* run, const float* image, float* out) {
    const int64_t d = run->net->qformer.width;
    const size_t floats = gsf__qformer_floats(run->net);
    float* x = (float*)gsf_alloc(run->nn.ctx, floats, sizeof(float));
    if (!x) return GSF_ERROR_OUT_OF_MEMORY;
    run->nn.vectors_size = (size_t)(2 * d);
    run->nn.vectors = x + floats - run->nn.vectors_size;
    const gsf_result result = gsf__qformer_layers(run, image, x + run->net->qformer.queries * d, x, out);
    gsf_free(run->nn.ctx, x);
    return result;
}

// ---- captioner: the language model

typedef struct gsf__opt_run {
    gsf__nn_cache cache;
    float *x, *logits; // (rows, width); (vocabulary), or with a tap (rows, vocabulary)
} gsf__opt_run;

// Divides `memory` into buffers; NULL: only counts the floats needed.
static size_t gsf__opt_lay_out(gsf__nn_run* run, const gsf__opt* opt, int64_t rows, int64_t logits, gsf__opt_run* o,
                               float* memory) {
    gsf__nn_arena arena = {memory, 0};
    const size_t d = (size_t)opt->sizes.width, n = (size_t)rows, wide = gsf__nn_wide(&opt->sizes, rows, GSF__VIT_MLP_ROWS);
    const size_t cache = (size_t)opt->layers * (size_t)o->cache.capacity * d;
    run->sizes = &opt->sizes;
    run->wide_count = (int64_t)wide;
    run->vectors_size = 2 * d;
    o->cache.keys = gsf__nn_share(&arena, cache);
    o->cache.values = gsf__nn_share(&arena, cache);
    o->x = gsf__nn_share(&arena, n * d);
    o->logits = gsf__nn_share(&arena, (size_t)logits * (size_t)opt->vocabulary);
    run->normed = gsf__nn_share(&arena, n * d);
    run->wide = gsf__nn_share(&arena, wide);
    run->vectors = gsf__nn_share(&arena, run->vectors_size);
    o->cache.mask = (unsigned char*)gsf__nn_share(&arena, ((size_t)opt->sizes.heads * n * n + 3) / 4);
    return arena.used;
}

// x (count, width): adds position embeddings from `place` on to the token embeddings of `ids`; with ids NULL, x already
// holds the token embeddings.
static void gsf__opt_embed(const gsf__opt* opt, const int32_t* ids, int64_t count, int64_t place, float* scratch,
                           float* x) {
    const int64_t d = opt->sizes.width;
    for (int64_t i = 0; i < count; i++) {
        if (ids) gsf_nn_convert_tensor(opt->tokens, ids[i] * d, d, x + i * d);
        gsf_nn_convert_tensor(opt->places, (place + i + GSF__OPT_OFFSET) * d, d, scratch);
        for (int64_t k = 0; k < d; k++) x[i * d + k] += scratch[k];
    }
}

// Runs all layers on the rows of x. o->logits receives the logits of the last row; a tap is shown all rows of a prefix.
static gsf_result gsf__opt_forward(gsf__caption_run* run, gsf__opt_run* o, int64_t rows) {
    const gsf__opt* opt = &run->net->text;
    gsf__nn_run* nn = &run->nn;
    const int64_t d = opt->sizes.width, shown = nn->tap && rows > 1 ? rows : 1;
    for (int64_t layer = 0; layer < opt->layers; layer++) {
        GSF__TRY(gsf__nn_block_forward(nn, &opt->blocks[layer], layer, o->x, 1, rows));
        GSF__TRY(gsf__nn_end_block(nn, "language_model.model.decoder.layers.", layer, o->x, rows * d));
    }
    o->cache.past += rows;
    const float* last = o->x + (rows - shown) * d;
    if (!opt->no_final_norm) {
        gsf__nn_norm(nn, &opt->norm, opt->sizes.eps, last, shown, nn->normed);
        last = nn->normed;
    }
    GSF__TRY(gsf__nn_linear(nn, &opt->head, GSF__NN_LINEAR, last, shown, o->logits, 0));
    GSF__TRY(gsf__nn_check(nn, "language_model.", "language_model.", o->logits, shown * opt->vocabulary));
    if (rows > 1) gsf__nn_reveal(nn, o->logits, 0, 1, shown, opt->vocabulary, "logits");
    if (shown > 1) memmove(o->logits, o->logits + (shown - 1) * opt->vocabulary, (size_t)opt->vocabulary * sizeof(float));
    return GSF_OK;
}

// Greedy decoding after the prefix in x (`rows` embeddings of queries and text, still without positions).
static gsf_result gsf__opt_continue(gsf__caption_run* run, gsf__opt_run* o, int64_t rows, int32_t most, int32_t* ids,
                                    size_t* count) {
    const gsf__opt* opt = &run->net->text;
    for (int64_t h = 0; h < opt->sizes.heads; h++)
        for (int64_t r = 0; r < rows; r++)
            for (int64_t k = 0; k < rows; k++) o->cache.mask[(h * rows + r) * rows + k] = k <= r;
    gsf__opt_embed(opt, NULL, rows, 0, run->nn.normed, o->x);
    GSF__TRY(gsf__opt_forward(run, o, rows));
    for (;;) {
        int32_t best = 0;
        for (int64_t i = 1; i < opt->vocabulary; i++)
            if (o->logits[i] > o->logits[best]) best = (int32_t)i;
        ids[(*count)++] = best;
        if (best == run->captioner->eos || *count == (size_t)most) break;
        gsf__opt_embed(opt, &best, 1, o->cache.past, run->nn.normed, o->x);
        GSF__TRY(gsf__opt_forward(run, o, 1));
    }
    gsf__progress(run->nn.ctx, run->nn.stage, run->nn.steps, run->nn.steps);
    return GSF_OK;
}

// Generates up to `most` new ids after the prefix of `words` (queries, width) and the text's ids; *count of them.
static gsf_result gsf__opt_write(gsf__caption_run* run, const float* words, const int32_t* text, size_t text_count,
                                 int32_t most, int32_t* ids, size_t* count) {
    const gsf__opt* opt = &run->net->text;
    gsf_context* ctx = run->nn.ctx;
    const int64_t d = opt->sizes.width, queries = run->net->qformer.queries, rows = queries + (int64_t)text_count;
    const int64_t logits = run->nn.tap ? rows : 1;
    gsf__opt_run o;
    memset(&o, 0, sizeof o);
    o.cache.capacity = rows + most - 1;
    float* memory = (float*)gsf_alloc(ctx, gsf__opt_lay_out(&run->nn, opt, rows, logits, &o, NULL), sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__opt_lay_out(&run->nn, opt, rows, logits, &o, memory);
    run->nn.cache = &o.cache;
    memcpy(o.x, words, (size_t)(queries * d) * sizeof(float));
    for (int64_t i = 0; i < (int64_t)text_count; i++)
        gsf_nn_convert_tensor(opt->tokens, text[i] * d, d, o.x + (queries + i) * d);
    const gsf_result result = gsf__opt_continue(run, &o, rows, most, ids, count);
    gsf_free(ctx, memory);
    return result;
}

// ---- captioner: API

// Ids of the text that follows the queries: only bos, or the tokenized prompt.
static gsf_result gsf__caption_text(gsf_context* ctx, const gsf_nn_captioner* captioner, const char* prompt, int32_t** ids,
                                    size_t* count) {
    *ids = NULL;
    *count = 0;
    if (!prompt) {
        *ids = (int32_t*)gsf_alloc(ctx, 1, sizeof **ids);
        if (!*ids) return GSF_ERROR_OUT_OF_MEMORY;
        (*ids)[(*count)++] = captioner->bos;
        return GSF_OK;
    }
    GSF__TRY(gsf_nn_encode_bpe(ctx, &captioner->tokenizer, prompt, strlen(prompt), 0, ids, count));
    gsf_result result = GSF_OK;
    if (!*count) result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "caption: the prompt has no tokens");
    for (size_t i = 0; i < *count && !result; i++) {
        if ((*ids)[i] >= captioner->vocabulary)
            result = gsf_fail(ctx, GSF_ERROR_FORMAT,
                              "caption: the tokenizer returned id %d, but the model has %d tokens",
                              (int)(*ids)[i], (int)captioner->vocabulary);
        else if ((*ids)[i] == captioner->image_token)
            result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "caption: the prompt contains the image token");
    }
    if (!result) return GSF_OK;
    gsf_free(ctx, *ids);
    *ids = NULL;
    *count = 0;
    return result;
}

// Maximal number of new tokens. The default for a folder without image_token_index follows from transformers'
// limit of 20 tokens in total, which counts the text twice.
static int64_t gsf__caption_most(const gsf_nn_captioner* captioner, int64_t text_tokens, int32_t wanted) {
    const int64_t usual = GSF__CAPTION_TOKENS;
    if (wanted > 0) return wanted;
    return captioner->image_token >= 0 ? usual : usual - 1 - 2 * text_tokens;
}

static gsf_result gsf__caption_check(gsf_context* ctx, const gsf_nn_captioner* captioner,
                                     const gsf__nn_caption_desc* desc, int64_t text_tokens, int64_t* most) {
    if (!desc->image || !desc->image->data) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "caption: no image");
    *most = gsf__caption_most(captioner, text_tokens, desc->max_new_tokens);
    if (*most < 1 || desc->max_new_tokens < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "caption: max_new_tokens is %d, and %lld tokens of text leave no room for new ones",
                        (int)desc->max_new_tokens, (long long)text_tokens);
    const int64_t places = captioner->query_tokens + text_tokens + *most - 1;
    if (places > captioner->positions)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "caption: %lld tokens, but the model has %d positions",
                        (long long)places, (int)captioner->positions);
    return GSF_OK;
}

static gsf_result gsf__caption_write(gsf__caption_run* run, const int32_t* text, size_t text_count, int64_t most,
                                     int32_t* ids, size_t* count) {
    const gsf__blip* net = run->net;
    gsf_context* ctx = run->nn.ctx;
    const size_t pixels = (size_t)(3 * net->image_size * net->image_size);
    const size_t seen = (size_t)((net->vision.grid * net->vision.grid + 1) * net->vision.sizes.width);
    float* words = (float*)gsf_alloc(ctx, (size_t)(net->qformer.queries * net->text.sizes.width), sizeof(float));
    float* image = (float*)gsf_alloc(ctx, pixels + seen, sizeof(float));
    gsf_result result = words && image ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    run->nn.steps = (double)(net->vision.layers + net->qformer.layers + net->text.layers * most);
    if (!result) result = gsf__blip_pixels(ctx, net, run->desc->image, image);
    if (!result) gsf__nn_reveal(&run->nn, image, 0, 1, 3, net->image_size * net->image_size, "pixel_values");
    if (!result) result = gsf__blip_look(run, image, image + pixels);
    if (!result) result = gsf__qformer_ask(run, image + pixels, words);
    gsf_free(ctx, image);
    if (!result) result = gsf__opt_write(run, words, text, text_count, (int32_t)most, ids, count);
    gsf_free(ctx, words);
    return result;
}

// Generates the caption's tokens, with `eos` if it ends there; free *ids with gsf_free.
static gsf_result gsf__nn_caption_ids(gsf_context* ctx, const gsf_nn_captioner* captioner,
                                      const gsf__nn_caption_desc* desc, int32_t** ids, size_t* count) {
    gsf__caption_run run;
    int32_t* text;
    size_t text_count;
    int64_t most = 0;
    *ids = NULL;
    *count = 0;
    memset(&run, 0, sizeof run);
    run.nn.ctx = ctx;
    run.nn.name = run.nn.stage = "caption";
    run.nn.weights = &captioner->weights;
    run.captioner = captioner;
    run.net = (const gsf__blip*)captioner->nets;
    run.desc = desc;
    run.nn.tap = desc->_tap;
    GSF__TRY(gsf__caption_text(ctx, captioner, desc->prompt, &text, &text_count));
    gsf_result result = gsf__caption_check(ctx, captioner, desc, (int64_t)text_count, &most);
    if (!result) {
        *ids = (int32_t*)gsf_alloc(ctx, (size_t)most, sizeof **ids);
        result = *ids ? gsf__caption_write(&run, text, text_count, most, *ids, count) : GSF_ERROR_OUT_OF_MEMORY;
    }
    gsf__nn_destroy_workspace(ctx, &run.nn.workspace);
    gsf_free(ctx, text);
    if (!result) return GSF_OK;
    gsf_free(ctx, *ids);
    *ids = NULL;
    *count = 0;
    return result;
}

GSF_API gsf_result gsf_nn_caption_image(gsf_context* ctx, const gsf_nn_captioner* captioner, const gsf_image* image,
                                        const char* prompt, int32_t max_new_tokens, char* out, size_t size) {
    gsf__nn_caption_desc desc;
    gsf_buffer text;
    int32_t* ids;
    size_t count, begin = 0;
    if (!out || !size) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "caption: no room for the text");
    out[0] = 0;
    memset(&desc, 0, sizeof desc);
    memset(&text, 0, sizeof text);
    desc.image = image;
    desc.prompt = prompt;
    desc.max_new_tokens = max_new_tokens;
    GSF__TRY(gsf__nn_caption_ids(ctx, captioner, &desc, &ids, &count));
    const gsf_result result = gsf_nn_decode_bpe(ctx, &captioner->tokenizer, ids, count, 1, &text);
    size_t end = text.size, used = 0;
    if (!result) gsf__bpe_strip((const gsf__bpe_tables*)captioner->tokenizer.tables, text.data, 1, 1, &begin, &end);
    for (size_t step; !result && begin < end; begin += step) { // only whole characters; U+FFFD replaces a zero byte
        step = gsf__utf8_size(text.data + begin, end - begin);
        const int zero = text.data[begin] == 0;
        if (used + (zero ? 3 : step) >= size) break;
        memcpy(out + used, zero ? "\xef\xbf\xbd" : text.data + begin, zero ? 3 : step);
        used += zero ? 3 : step;
    }
    out[used] = 0;
    gsf_destroy_buffer(ctx, &text);
    gsf_free(ctx, ids);
    return result;
}

// Peak memory in bytes (in addition to mapped weights and kernel scratch) and floating-point operations of one caption
// with a prompt of `text_tokens` tokens (0: no prompt).
static void gsf__nn_query_captioner(const gsf_nn_captioner* captioner, int64_t text_tokens, int32_t max_new_tokens,
                                    double* bytes, double* flops) {
    const gsf__blip* net = (const gsf__blip*)captioner->nets;
    const gsf__qformer* q = &net->qformer;
    const gsf__opt* opt = &net->text;
    gsf_nn_encoder_desc in;
    memset(&in, 0, sizeof in);
    in.images = 1;
    in.height = in.width = (int32_t)net->image_size;
    if (text_tokens < 1) text_tokens = 1;
    int64_t most = gsf__caption_most(captioner, text_tokens, max_new_tokens);
    if (most < 1) most = 1;
    gsf__nn_run run;
    gsf__opt_run o;
    memset(&run, 0, sizeof run);
    memset(&o, 0, sizeof o);
    const int64_t rows = q->queries + text_tokens;
    o.cache.capacity = rows + most - 1;
    const double seen = (double)(net->vision.grid * net->vision.grid + 1);
    const double words = 4.0 * (double)q->queries * (double)opt->sizes.width;
    const double image = 12.0 * (double)net->image_size * (double)net->image_size +
                         4.0 * seen * (double)net->vision.sizes.width;
    const double look = image + gsf__vit_bytes(&net->vision, NULL, &in), ask = image + 4.0 * (double)gsf__qformer_floats(net);
    const double write = 4.0 * (double)gsf__opt_lay_out(&run, opt, rows, 1, &o, NULL), first = look > ask ? look : ask;
    if (bytes) *bytes = words + (first > write ? first : write);
    const double d = (double)q->width, n = (double)q->queries;
    const double crossing = (double)gsf__ceil_div(q->layers, q->cross_every);
    const double self = 8.0 * n * d * d + 4.0 * n * n * d + 4.0 * n * d * (double)q->mlp;
    const double cross = 4.0 * n * d * d + 4.0 * seen * d * (double)net->vision.sizes.width + 4.0 * n * seen * d;
    const double w = (double)opt->sizes.width, all = (double)(rows + most - 1);
    const double row = 2.0 * w * (4.0 * w + 2.0 * (double)opt->sizes.mlp), layers = (double)opt->layers;
    if (flops)
        *flops = gsf__vit_flops(&net->vision, &in) + (double)q->layers * self + crossing * cross +
                 2.0 * n * d * w + layers * (all * row + 2.0 * all * all * w) +
                 2.0 * (double)most * w * (double)opt->vocabulary;
}

// ---- >>nn tokenizer -------------------------------------------------------------

/* spiece.model is a protobuf message: fields, each a varint (field number << 3 | wire type) and its value. Read are
       1 piece, repeated   1 text, 2 score (float), 3 type: 1 normal, 2 unknown, 3 control, 4 user-defined, 5 unused, 6 byte
       2 trainer           3 model type: 1 unigram; 24 space follows the word; 35 unknown characters as bytes
       3 normalizer        2 character map, 3 dummy prefix, 4 remove extra spaces, 5 escape spaces; 3 to 5 default to 1
   To encode a text, added tokens are cut out; the text between them is normalized and segmented into the pieces with
   the largest sum of scores (Viterbi). A character that is not a piece scores 10 less than the lowest score.
   (github.com/google/sentencepiece: src/sentencepiece_model.proto, normalizer.cc, unigram_model.cc EncodeOptimized,
   sentencepiece_processor.cc; transformers 4.51.3: tokenization_utils.py, tokenization_t5.py) */
enum {
    GSF__SP_NORMAL = 1, GSF__SP_UNKNOWN, GSF__SP_CONTROL, GSF__SP_USER, GSF__SP_UNUSED, GSF__SP_BYTE, GSF__SP_TYPES,
    GSF__SP_PIECE = 1024,       // limit in bytes of a piece and of an added token
    GSF__SP_REPLACEMENT = 255,  // of a replacement in the character map
    GSF__SP_MATCH = 256,        // of a match of the character map: bounds the time per byte of text for any file
    GSF__SP_EXTRA = 100,        // number of T5's <extra_id_...> tokens
};

static const char gsf__sp_space[] = "\xe2\x96\x81"; // U+2581 represents a space

// ---- protobuf

typedef struct gsf__pb {
    gsf_context* ctx;
    const char* name; // for error messages
    const unsigned char* data;
    size_t at, end;
} gsf__pb;

typedef struct gsf__pb_field {
    uint64_t number, value; // value: for all wire types except 2
    int wire;               // 0 varint, 1 eight bytes, 2 length-prefixed bytes, 5 four bytes
    size_t at, size;        // of the bytes of wire types 1, 2 and 5
} gsf__pb_field;

static gsf_result gsf__pb_varint(gsf__pb* in, uint64_t* out) {
    const size_t begin = in->at;
    *out = 0;
    for (int shift = 0; shift < 70; shift += 7) {
        if (in->at == in->end)
            return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: a varint is truncated", in->name, begin);
        const unsigned char byte = in->data[in->at++];
        if (shift < 64) *out |= (uint64_t)(byte & 127u) << shift;
        if (!(byte & 128u)) return GSF_OK;
    }
    return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: a varint of more than ten bytes", in->name, begin);
}

static gsf_result gsf__pb_next(gsf__pb* in, gsf__pb_field* out) { // requires in->at < in->end
    const size_t begin = in->at;
    uint64_t key, size = 0;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf__pb_varint(in, &key));
    out->number = key >> 3;
    out->wire = (int)(key & 7);
    if (out->number < 1 || out->number >= 1u << 29)
        return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: invalid field number %llu", in->name, begin,
                        (unsigned long long)out->number);
    if (out->wire == 0) return gsf__pb_varint(in, &out->value);
    if (out->wire == 1) size = 8;
    else if (out->wire == 5) size = 4;
    else if (out->wire == 2) GSF__TRY(gsf__pb_varint(in, &size));
    else return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: wire type %d", in->name, begin, out->wire);
    if (size > in->end - in->at)
        return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: field %d has %llu bytes, but %zu are left", in->name, begin,
                        (int)out->number, (unsigned long long)size, in->end - in->at);
    out->at = in->at;
    out->size = (size_t)size;
    if (out->wire != 2) out->value = gsf__load_le(in->data + in->at, (int)size);
    in->at += out->size;
    return GSF_OK;
}

static gsf_result gsf__pb_expect(const gsf__pb* in, const gsf__pb_field* field, int wire) {
    if (field->wire == wire) return GSF_OK;
    return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: field %d has wire type %d, not %d", in->name, in->at,
                    (int)field->number, field->wire, wire);
}

static gsf__pb gsf__pb_inside(const gsf__pb* in, const gsf__pb_field* field) { // the message inside a field
    gsf__pb out = *in;
    out.at = field->at;
    out.end = field->at + field->size;
    return out;
}

// ---- a trie over texts

typedef struct gsf__sp_key {
    const char* text;
    uint32_t size;
    int32_t id;
} gsf__sp_key;

typedef struct gsf__sp_node { // children are contiguous, sorted by byte
    uint32_t first;
    int32_t id; // of the text that ends at this node; -1: none
    uint16_t count;
    unsigned char byte;
} gsf__sp_node;

typedef struct gsf__sp_range { uint32_t begin, end, depth; } gsf__sp_range; // of the sorted keys below a node

static int gsf__sp_compare(const void* a, const void* b) { // by bytes, then by id
    const gsf__sp_key *x = (const gsf__sp_key*)a, *y = (const gsf__sp_key*)b;
    const int order = memcmp(x->text, y->text, x->size < y->size ? x->size : y->size);
    if (order) return order;
    if (x->size != y->size) return x->size < y->size ? -1 : 1;
    return x->id < y->id ? -1 : x->id > y->id;
}

static uint32_t gsf__sp_shared(const gsf__sp_key* a, const gsf__sp_key* b) { // length of the common prefix
    uint32_t n = 0;
    while (n < a->size && n < b->size && a->text[n] == b->text[n]) n++;
    return n;
}

// Builds a trie in breadth-first order from sorted keys with distinct, nonempty texts; the caller frees *out.
static gsf_result gsf__sp_build_trie(gsf_context* ctx, const gsf__sp_key* keys, size_t count, gsf__sp_node** out) {
    size_t total = 1, made = 1;
    for (size_t i = 0; i < count; i++) total += keys[i].size - (i ? gsf__sp_shared(&keys[i - 1], &keys[i]) : 0);
    if (total > UINT32_MAX) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "tokenizer: %zu pieces are too many", count);
    gsf__sp_node* nodes = (gsf__sp_node*)gsf_alloc_zeroed(ctx, total, sizeof *nodes);
    gsf__sp_range* ranges = (gsf__sp_range*)gsf_alloc_zeroed(ctx, total, sizeof *ranges);
    *out = nodes;
    if (!nodes || !ranges) {
        gsf_free(ctx, ranges);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    ranges[0].end = (uint32_t)count;
    for (size_t n = 0; n < total; n++) {
        const gsf__sp_range r = ranges[n];
        uint32_t at = r.begin;
        nodes[n].id = -1;
        if (at < r.end && keys[at].size == r.depth) nodes[n].id = keys[at++].id;
        nodes[n].first = (uint32_t)made;
        while (at < r.end) {
            const uint32_t begin = at;
            const char byte = keys[at].text[r.depth];
            while (at < r.end && keys[at].text[r.depth] == byte) at++;
            nodes[made].byte = (unsigned char)byte;
            ranges[made].begin = begin;
            ranges[made].end = at;
            ranges[made++].depth = r.depth + 1;
            nodes[n].count++;
        }
    }
    GSF_ASSERT(made == total);
    gsf_free(ctx, ranges);
    return GSF_OK;
}

static const gsf__sp_node* gsf__sp_child(const gsf__sp_node* nodes, const gsf__sp_node* node, unsigned char byte) {
    uint32_t low = node->first, high = low + node->count;
    const uint32_t end = high;
    while (low < high) {
        const uint32_t mid = low + (high - low) / 2;
        if (nodes[mid].byte < byte) low = mid + 1;
        else high = mid;
    }
    return low < end && nodes[low].byte == byte ? &nodes[low] : NULL;
}

static int32_t gsf__sp_find(const gsf__sp_node* nodes, const char* text, size_t size) { // id of a text, or -1
    const gsf__sp_node* node = nodes;
    for (size_t i = 0; node && i < size; i++) node = gsf__sp_child(nodes, node, (unsigned char)text[i]);
    return node ? node->id : -1;
}

// Id and *length of the longest text in the trie that is a prefix of `text`; -1 and 0 if there is none. types:
// restricts the search to user-defined pieces.
static int32_t gsf__sp_longest(const gsf__sp_node* nodes, const unsigned char* types, const char* text, size_t left,
                               size_t* length) {
    int32_t found = -1;
    const gsf__sp_node* node = nodes;
    *length = 0;
    for (size_t i = 0; i < left && (node = gsf__sp_child(nodes, node, (unsigned char)text[i])) != NULL; i++) {
        if (node->id < 0 || (types && types[node->id] != GSF__SP_USER)) continue;
        found = node->id;
        *length = i + 1;
    }
    return found;
}

// ---- the model

typedef struct gsf__sp_added { // a text with an id of its own
    size_t at, size;           // in gsf__sp_model.texts, while loading
    int32_t id;
    int trim_left, trim_right; // also removes the white space on that side
} gsf__sp_added;

typedef struct gsf__sp_model { // pointed to by gsf_nn_tokenizer.model
    gsf__sp_node *pieces, *added; // ids of `added` are indices into added_list
    gsf__sp_added* added_list;
    gsf_buffer texts;
    size_t added_count, added_capacity;
    float* scores;                // per piece, like types
    unsigned char* types;
    size_t count, scores_capacity, types_capacity;
    float unknown_score;
    int32_t unknown_id, bytes[256];
    uint32_t* units;              // character map: a double-array trie; unit_count 0: none
    size_t unit_count;
    char* replacements;           // the trie's values are offsets into this, each of a zero-terminated text
    size_t replacements_size;
    int prefix, trim, escape, suffix, byte_fallback, has_user_pieces;
} gsf__sp_model;

static void gsf__sp_destroy(gsf_context* ctx, gsf__sp_model* m) {
    if (!m) return;
    gsf_free(ctx, m->pieces);
    gsf_free(ctx, m->added);
    gsf_free(ctx, m->added_list);
    gsf_destroy_buffer(ctx, &m->texts);
    gsf_free(ctx, m->scores);
    gsf_free(ctx, m->types);
    gsf_free(ctx, m->units);
    gsf_free(ctx, m->replacements);
    gsf_free(ctx, m);
}

GSF_API void gsf_nn_destroy_tokenizer(gsf_context* ctx, gsf_nn_tokenizer* tokenizer) {
    gsf__sp_destroy(ctx, (gsf__sp_model*)tokenizer->model);
    memset(tokenizer, 0, sizeof *tokenizer);
}

// ---- loading: pieces

static int gsf__sp_is_text(const char* text, size_t size) { // UTF-8 without zero bytes
    for (size_t at = 0, step; at < size; at += step) {
        step = text[at] ? gsf__utf8_size(text + at, size - at) : 0;
        if (!step) return 0;
    }
    return 1;
}

static gsf_result gsf__sp_read_piece(gsf__pb in, gsf__sp_key* key, float* score, unsigned char* type) {
    const size_t begin = in.at;
    uint64_t kind = GSF__SP_NORMAL;
    gsf__pb_field field;
    *score = 0.0f;
    while (in.at < in.end) {
        GSF__TRY(gsf__pb_next(&in, &field));
        if (field.number == 1) {
            GSF__TRY(gsf__pb_expect(&in, &field, 2));
            if (field.size > GSF__SP_PIECE || !gsf__sp_is_text((const char*)in.data + field.at, field.size))
                return gsf_fail(in.ctx, GSF_ERROR_FORMAT, "%s:%zu: piece %d is not valid UTF-8 or longer than %d bytes",
                                in.name, field.at, (int)key->id, (int)GSF__SP_PIECE);
            key->text = (const char*)in.data + field.at;
            key->size = (uint32_t)field.size;
        } else if (field.number == 2) {
            GSF__TRY(gsf__pb_expect(&in, &field, 5));
            const uint32_t bits = (uint32_t)field.value;
            memcpy(score, &bits, sizeof bits);
        } else if (field.number == 3) {
            GSF__TRY(gsf__pb_expect(&in, &field, 0));
            kind = field.value;
        }
    }
    if (key->size == 0 || !(fabsf(*score) <= 1e30f) || kind < GSF__SP_NORMAL || kind >= GSF__SP_TYPES)
        return gsf_fail(in.ctx, GSF_ERROR_FORMAT, "%s:%zu: piece %d has %u bytes, score %g and type %llu", in.name, begin,
                        (int)key->id, (unsigned)key->size, (double)*score, (unsigned long long)kind);
    *type = (unsigned char)kind;
    return GSF_OK;
}

// "<0x1F>" gives 31; -1: not of that form
static int gsf__sp_byte_of(const gsf__sp_key* key) {
    static const char digits[] = "0123456789ABCDEF";
    if (key->size != 6 || memcmp(key->text, "<0x", 3) != 0 || key->text[5] != '>') return -1;
    const char *high = strchr(digits, key->text[3]), *low = strchr(digits, key->text[4]);
    return high && low ? (int)(high - digits) * 16 + (int)(low - digits) : -1;
}

static gsf_result gsf__sp_note_piece(const gsf__pb* in, gsf__sp_model* m, const gsf__sp_key* key) {
    const int type = m->types[key->id];
    if (type == GSF__SP_UNKNOWN) {
        if (m->unknown_id >= 0)
            return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s: pieces %d and %d are both of type unknown", in->name,
                            (int)m->unknown_id, (int)key->id);
        m->unknown_id = key->id;
    } else if (type == GSF__SP_BYTE) {
        const int byte = gsf__sp_byte_of(key);
        if (byte < 0)
            return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s: piece %d of type byte is not of the form <0xNN>", in->name,
                            (int)key->id);
        m->bytes[byte] = key->id;
    } else if (type == GSF__SP_USER) {
        m->has_user_pieces = 1;
    }
    return GSF_OK;
}

static gsf_result gsf__sp_read_trainer(gsf__pb in, gsf__sp_model* m) {
    gsf__pb_field field;
    while (in.at < in.end) {
        GSF__TRY(gsf__pb_next(&in, &field));
        if (field.number != 3 && field.number != 24 && field.number != 35) continue;
        GSF__TRY(gsf__pb_expect(&in, &field, 0));
        if (field.number == 24) m->suffix = field.value != 0;
        else if (field.number == 35) m->byte_fallback = field.value != 0;
        else if (field.value != 1)
            return gsf_fail(in.ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: model type %llu is not unigram (1)", in.name, in.at,
                            (unsigned long long)field.value);
    }
    return GSF_OK;
}

// ---- loading: the character map

/* Layout: u32 bytes of the trie | its units, each u32 | zero-terminated texts
   A unit of the double array: label in bits 0-7 and 31 (a byte, or 1 << 31 for a value), bit 8: one of the children is
   a value, offset in bits 10-31, times 256 if bit 9 is set. The child of unit i for byte b is unit i ^ offset ^ b if
   its label is b; a value is stored in bits 0-30 of the child for byte 0. (github.com/s-yata/darts-clone) */
static uint32_t gsf__sp_offset(uint32_t unit) { return unit >> 10 << ((unit & 512u) >> 6); }

// Checks every unit, so that no lookup leaves the array. The children of a unit share a block of 256, and the number of
// units is a multiple of 256, so it is enough to check the base.
static gsf_result gsf__sp_check_units(const gsf__pb* in, size_t at, const gsf__sp_model* m) {
    for (size_t i = 0; i < m->unit_count; i++) {
        const uint32_t unit = m->units[i];
        if (unit >> 31 && i > 0) continue; // a value
        const size_t base = i ^ gsf__sp_offset(unit);
        const uint32_t value = base < m->unit_count ? m->units[base] & 0x7fffffffu : 0;
        int ok = !(unit >> 31) && base < m->unit_count;
        if (ok && unit >> 8 & 1u) {
            const size_t left = value < m->replacements_size ? m->replacements_size - value : 0;
            const size_t most = left <= GSF__SP_REPLACEMENT ? left : GSF__SP_REPLACEMENT + 1;
            ok = most && memchr(m->replacements + value, 0, most) != NULL;
        }
        if (!ok)
            return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: unit %zu of the character map is invalid", in->name,
                            at + 4 * i, i);
    }
    return GSF_OK;
}

static gsf_result gsf__sp_read_map(const gsf__pb* in, const gsf__pb_field* field, gsf__sp_model* m) {
    const unsigned char* data = in->data + field->at;
    gsf_free(in->ctx, m->units); // replaces that of an earlier field
    gsf_free(in->ctx, m->replacements);
    m->units = NULL;
    m->replacements = NULL;
    m->unit_count = m->replacements_size = 0;
    if (field->size == 0) return GSF_OK;
    const size_t bytes = field->size >= 4 ? (size_t)gsf__load_le(data, 4) : 0;
    if (field->size < 5 || bytes > field->size - 5 || bytes == 0 || bytes % 1024 || data[field->size - 1] != 0)
        return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s:%zu: a character map of %zu bytes with %zu of trie", in->name,
                        field->at, field->size, bytes);
    m->unit_count = bytes / 4;
    m->replacements_size = field->size - 4 - bytes;
    m->units = (uint32_t*)gsf_alloc(in->ctx, m->unit_count, sizeof *m->units);
    m->replacements = (char*)gsf_alloc(in->ctx, m->replacements_size, 1);
    if (!m->units || !m->replacements) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < m->unit_count; i++) m->units[i] = (uint32_t)gsf__load_le(data + 4 + 4 * i, 4);
    memcpy(m->replacements, data + 4 + bytes, m->replacements_size);
    return gsf__sp_check_units(in, field->at + 4, m);
}

static gsf_result gsf__sp_read_normalizer(gsf__pb in, gsf__sp_model* m) {
    gsf__pb_field field;
    while (in.at < in.end) {
        GSF__TRY(gsf__pb_next(&in, &field));
        if (field.number == 2) {
            GSF__TRY(gsf__pb_expect(&in, &field, 2));
            GSF__TRY(gsf__sp_read_map(&in, &field, m));
        } else if (field.number >= 3 && field.number <= 5) {
            GSF__TRY(gsf__pb_expect(&in, &field, 0));
            *(field.number == 3 ? &m->prefix : field.number == 4 ? &m->trim : &m->escape) = field.value != 0;
        }
    }
    return GSF_OK;
}

// ---- loading: the whole file

typedef struct gsf__sp_keys { // the texts point into the caller's buffer
    gsf__sp_key* keys;
    size_t count, capacity;
} gsf__sp_keys;

static gsf_result gsf__sp_add_piece(const gsf__pb* in, const gsf__pb_field* field, gsf__sp_model* m, gsf__sp_keys* all) {
    const size_t n = all->count;
    if (n >= INT32_MAX) return gsf_fail(in->ctx, GSF_ERROR_UNSUPPORTED, "%s: too many pieces", in->name);
    GSF__TRY(gsf__reserve(in->ctx, (void**)&all->keys, &all->capacity, n, n + 1, sizeof *all->keys));
    GSF__TRY(gsf__reserve(in->ctx, (void**)&m->scores, &m->scores_capacity, n, n + 1, sizeof *m->scores));
    GSF__TRY(gsf__reserve(in->ctx, (void**)&m->types, &m->types_capacity, n, n + 1, 1));
    memset(&all->keys[n], 0, sizeof all->keys[n]);
    all->keys[n].id = (int32_t)n;
    GSF__TRY(gsf__sp_read_piece(gsf__pb_inside(in, field), &all->keys[n], &m->scores[n], &m->types[n]));
    GSF__TRY(gsf__sp_note_piece(in, m, &all->keys[n]));
    all->count = m->count = n + 1;
    return GSF_OK;
}

static gsf_result gsf__sp_check_pieces(const gsf__pb* in, gsf__sp_model* m, const gsf__sp_keys* all) {
    float low = FLT_MAX;
    for (size_t i = 0; i < m->count; i++)
        if (m->types[i] == GSF__SP_NORMAL && m->scores[i] < low) low = m->scores[i];
    m->unknown_score = low - 10.0f;
    if (m->unknown_id < 0) return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s: no piece is of type unknown", in->name);
    for (int i = 0; m->byte_fallback && i < 256; i++)
        if (m->bytes[i] < 0) return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s: no piece for the byte %d", in->name, i);
    qsort(all->keys, all->count, sizeof *all->keys, gsf__sp_compare);
    for (size_t i = 1; i < all->count; i++) {
        const gsf__sp_key *a = &all->keys[i - 1], *b = &all->keys[i];
        if (a->size == b->size && memcmp(a->text, b->text, a->size) == 0)
            return gsf_fail(in->ctx, GSF_ERROR_FORMAT, "%s: pieces %d and %d have the same text", in->name, (int)a->id,
                            (int)b->id);
    }
    return gsf__sp_build_trie(in->ctx, all->keys, all->count, &m->pieces);
}

static gsf_result gsf__sp_read_model(gsf__pb in, gsf__sp_model* m) {
    gsf__sp_keys all;
    gsf__pb_field field;
    gsf_result result = GSF_OK;
    memset(&all, 0, sizeof all);
    m->unknown_id = -1;
    for (int i = 0; i < 256; i++) m->bytes[i] = -1;
    m->prefix = m->trim = m->escape = 1;
    while (in.at < in.end && result == GSF_OK) {
        result = gsf__pb_next(&in, &field);
        if (result || field.number > 3) continue;
        result = gsf__pb_expect(&in, &field, 2);
        if (result) break;
        if (field.number == 1) result = gsf__sp_add_piece(&in, &field, m, &all);
        else if (field.number == 2) result = gsf__sp_read_trainer(gsf__pb_inside(&in, &field), m);
        else result = gsf__sp_read_normalizer(gsf__pb_inside(&in, &field), m);
    }
    if (result == GSF_OK) result = gsf__sp_check_pieces(&in, m, &all);
    gsf_free(in.ctx, all.keys);
    return result;
}

// ---- loading: added tokens

typedef struct gsf__sp_adding {
    gsf_context* ctx;
    gsf__sp_model* m;
    const char* name; // for error messages
} gsf__sp_adding;

static gsf_result gsf__sp_add(void* user, const gsf__bpe_token* token) {
    gsf__sp_model* m = ((gsf__sp_adding*)user)->m;
    gsf_context* ctx = ((gsf__sp_adding*)user)->ctx;
    const size_t n = m->added_count;
    if (token->size == 0) return GSF_OK;
    if (token->size > GSF__SP_PIECE)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: added token %s is longer than %d bytes",
                        ((gsf__sp_adding*)user)->name, gsf__nn_show(token->text).text, (int)GSF__SP_PIECE);
    GSF__TRY(gsf__reserve(ctx, (void**)&m->added_list, &m->added_capacity, n, n + 1, sizeof *m->added_list));
    gsf__sp_added* a = &m->added_list[n];
    a->at = m->texts.size;
    a->size = token->size;
    a->id = token->id;
    a->trim_left = (token->flags & GSF__BPE_LSTRIP) != 0;
    a->trim_right = (token->flags & GSF__BPE_RSTRIP) != 0;
    gsf_append_bytes(ctx, &m->texts, token->text, token->size);
    m->added_count++;
    return m->texts.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

static gsf_result gsf__sp_add_extra(gsf__sp_adding* adding, int64_t extra) {
    for (int64_t i = 0; i < extra; i++) {
        char text[32];
        const int size = snprintf(text, sizeof text, "<extra_id_%d>", (int)i); // extra_id_0 has the highest id
        const gsf__bpe_token token = {text, (size_t)size, (int32_t)((int64_t)adding->m->count - 1 + extra - i),
                                      GSF__BPE_LSTRIP | GSF__BPE_RSTRIP};
        GSF__TRY(gsf__sp_add(adding, &token));
    }
    return GSF_OK;
}

// Sorts the added tokens into a trie; of tokens with the same text, the one added last wins.
static gsf_result gsf__sp_sort_added(gsf_context* ctx, gsf__sp_model* m) {
    size_t kept = 0;
    gsf__sp_key* keys = (gsf__sp_key*)gsf_alloc(ctx, m->added_count, sizeof *keys);
    if (!keys) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < m->added_count; i++) {
        keys[i].text = m->texts.data + m->added_list[i].at;
        keys[i].size = (uint32_t)m->added_list[i].size;
        keys[i].id = (int32_t)i;
    }
    if (m->added_count) qsort(keys, m->added_count, sizeof *keys, gsf__sp_compare);
    for (size_t i = 0; i < m->added_count; i++) {
        const int again = kept && keys[kept - 1].size == keys[i].size &&
                          memcmp(keys[kept - 1].text, keys[i].text, keys[i].size) == 0;
        keys[again ? kept - 1 : kept++] = keys[i];
    }
    const gsf_result result = gsf__sp_build_trie(ctx, keys, kept, &m->added);
    gsf_free(ctx, keys);
    gsf_destroy_buffer(ctx, &m->texts);
    return result;
}

// Text of a key such as "eos_token": a string, or an object with the string in "content".
static const char* gsf__sp_token_text(const gsf__nn_config* file, const char* key, const char* fallback) {
    const gsf_json_value* value = gsf__nn_config_find(file, key);
    if (value && value->type == GSF_JSON_OBJECT) value = gsf_find_json_member(&file->json, value, "content");
    return value && value->type == GSF_JSON_STRING ? value->string : fallback;
}

static gsf_result gsf__sp_add_all(gsf_context* ctx, const char* name, const gsf__nn_config* config,
                                  const gsf__nn_config* added, gsf__sp_model* m, gsf_nn_tokenizer* out) {
    static const char* const names[][2] = {{"unk_token", "<unk>"}, {"eos_token", "</s>"}, {"pad_token", "<pad>"}};
    int32_t* const ids[] = {NULL, &out->end_id, &out->pad_id};
    int64_t extra = GSF__SP_EXTRA;
    gsf__sp_adding adding = {ctx, m, name};
    for (size_t i = 0; i < GSF__COUNT(names); i++) {
        const char* text = gsf__sp_token_text(config, names[i][0], names[i][1]);
        const int32_t id = strlen(text) <= GSF__SP_PIECE ? gsf__sp_find(m->pieces, text, strlen(text)) : -1;
        const gsf__bpe_token token = {text, strlen(text), id, 0};
        if (id >= 0) GSF__TRY(gsf__sp_add(&adding, &token));
    }
    GSF__TRY(gsf__nn_config_int_or(config, "extra_ids", extra, 0, 100000, &extra));
    if ((int64_t)m->count > INT32_MAX - extra) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: too many pieces", name);
    GSF__TRY(gsf__sp_add_extra(&adding, extra));
    GSF__TRY(gsf__nn_read_added(config, gsf__nn_config_find(config, "added_tokens_decoder"), added, gsf__sp_add, &adding));
    GSF__TRY(gsf__sp_sort_added(ctx, m));
    out->id_count = (int32_t)m->count;
    for (size_t i = 0; i < m->added_count; i++)
        if (m->added_list[i].id >= out->id_count) out->id_count = m->added_list[i].id + 1;
    for (size_t i = 1; i < GSF__COUNT(names); i++) {
        const char* text = gsf__sp_token_text(config, names[i][0], names[i][1]);
        const int32_t place = gsf__sp_find(m->added, text, strlen(text));
        if (place < 0)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: there is no %s %s", name, names[i][0], gsf__nn_show(text).text);
        *ids[i] = m->added_list[place].id;
    }
    return GSF_OK;
}

// files: tokenizer_config.json and added_tokens.json, or empty objects if the file does not exist.
static gsf_result gsf__sp_make(gsf_context* ctx, const char* name, const void* data, size_t size,
                               const gsf__nn_config files[2], gsf_nn_tokenizer* out) {
    const gsf__pb in = {ctx, gsf__nn_path_end(name), (const unsigned char*)data, 0, size};
    gsf__sp_model* m = (gsf__sp_model*)gsf_alloc_zeroed(ctx, 1, sizeof *m);
    out->model = m;
    if (!m) return GSF_ERROR_OUT_OF_MEMORY;
    GSF__TRY(gsf__sp_read_model(in, m));
    out->piece_count = (int32_t)m->count;
    out->unknown_id = m->unknown_id;
    return gsf__sp_add_all(ctx, in.name, &files[0], &files[1], m, out);
}

static void gsf__sp_end_making(gsf_context* ctx, gsf_result result, gsf__nn_config files[2], gsf_nn_tokenizer* out) {
    for (int i = 0; i < 2; i++) gsf_destroy_json(ctx, &files[i].json);
    if (result) gsf_nn_destroy_tokenizer(ctx, out);
}

// Like gsf_nn_load_tokenizer, from the bytes of a spiece.model and of a tokenizer_config.json (NULL: none), which are
// not referenced afterwards.
GSF__SHARED gsf_result gsf__nn_parse_tokenizer(gsf_context* ctx, const char* name, const void* model, size_t model_size,
                                               const char* config, size_t config_size, gsf_nn_tokenizer* out) {
    gsf__nn_config files[2];
    memset(files, 0, sizeof files);
    memset(out, 0, sizeof *out);
    gsf_result result = gsf__nn_parse_config(ctx, "tokenizer_config.json", config ? config : "{}", config ? config_size : 2,
                                             &files[0]);
    if (!result) result = gsf__nn_parse_config(ctx, "added_tokens.json", "{}", 2, &files[1]);
    if (!result) result = gsf__sp_make(ctx, name, model, model_size, files, out);
    gsf__sp_end_making(ctx, result, files, out);
    return result;
}

GSF_API gsf_result gsf_nn_load_tokenizer(gsf_context* ctx, const char* folder, gsf_nn_tokenizer* out) {
    gsf__nn_config files[2];
    void* data = NULL;
    size_t size = 0;
    gsf_buffer path;
    memset(files, 0, sizeof files);
    memset(out, 0, sizeof *out);
    gsf_result result = gsf__nn_join(ctx, folder, "spiece.model", &path);
    if (!result) result = gsf_read_file(ctx, path.data, &data, &size);
    if (!result) result = gsf__nn_open_config(ctx, folder, "tokenizer_config.json", 1, &files[0]);
    if (!result) result = gsf__nn_open_config(ctx, folder, "added_tokens.json", 1, &files[1]);
    if (!result) result = gsf__sp_make(ctx, path.data, data, size, files, out);
    gsf_free(ctx, data);
    gsf_destroy_buffer(ctx, &path);
    gsf__sp_end_making(ctx, result, files, out);
    return result;
}

// ---- normalizing

typedef struct gsf__sp_step { // replacement of the next `used` bytes
    const char* text;
    size_t size, used;
} gsf__sp_step;

// Length of the longest entry of the character map that is a prefix of the text, 0: none.
static size_t gsf__sp_match(const gsf__sp_model* m, const char* text, size_t left, uint32_t* value) {
    size_t length = 0;
    if (left > GSF__SP_MATCH) left = GSF__SP_MATCH;
    uint32_t at = gsf__sp_offset(m->units[0]);
    for (size_t i = 0; i < left; i++) {
        const unsigned char byte = (unsigned char)text[i];
        at ^= byte;
        const uint32_t unit = m->units[at];
        if ((unit & 0x800000ffu) != byte) break;
        at ^= gsf__sp_offset(unit);
        if (unit >> 8 & 1u) {
            length = i + 1;
            *value = m->units[at] & 0x7fffffffu;
        }
    }
    return length;
}

static gsf__sp_step gsf__sp_next(const gsf__sp_model* m, const char* text, size_t left) {
    gsf__sp_step step = {text, 0, 0};
    uint32_t value = 0;
    // user-defined pieces are not normalized
    if (m->has_user_pieces) gsf__sp_longest(m->pieces, m->types, text, left, &step.used);
    if (!step.used && m->unit_count) {
        step.used = gsf__sp_match(m, text, left, &value);
        if (step.used) {
            step.text = m->replacements + value;
            step.size = strlen(step.text);
            return step;
        }
    }
    if (!step.used) step.used = gsf__utf8_size(text, left);
    step.size = step.used;
    if (step.used) return step;
    step.text = "\xef\xbf\xbd"; // U+FFFD replaces a malformed byte
    step.size = 3;
    step.used = 1;
    return step;
}

typedef struct gsf__sp_best { // best segmentation of all bytes before this one
    float score;
    int32_t id;     // its last piece; -1: none yet
    uint32_t start; // where the last piece begins
    uint32_t next;  // for the backtrace: end of the piece that begins here
} gsf__sp_best;

typedef struct gsf__sp_run {
    gsf_context* ctx;
    const gsf__sp_model* m;
    char* normal;
    size_t size, capacity;
    gsf__sp_best* best;
    size_t best_capacity;
    gsf__nn_ids out;
} gsf__sp_run;

static gsf_result gsf__sp_put(gsf__sp_run* run, const char* text, size_t size) { // escapes spaces
    GSF__TRY(gsf__reserve(run->ctx, (void**)&run->normal, &run->capacity, run->size, run->size + 3 * size, 1));
    for (size_t i = 0; i < size; i++) {
        if (text[i] == ' ' && run->m->escape) {
            memcpy(run->normal + run->size, gsf__sp_space, 3);
            run->size += 3;
        } else {
            run->normal[run->size++] = text[i];
        }
    }
    return run->size < INT32_MAX ? GSF_OK
                                 : gsf_fail(run->ctx, GSF_ERROR_INVALID_ARGUMENT, "tokenizer: the text is too long");
}

static gsf_result gsf__sp_normalize(gsf__sp_run* run, const char* text, size_t left) {
    const gsf__sp_model* m = run->m;
    const char* space = m->escape ? gsf__sp_space : " ";
    const size_t space_size = strlen(space);
    int after_space = m->trim;
    run->size = 0;
    while (m->trim && left) { // leading spaces
        const gsf__sp_step s = gsf__sp_next(m, text, left);
        if (s.size != 1 || s.text[0] != ' ') break;
        text += s.used;
        left -= s.used;
    }
    if (!left) return GSF_OK;
    if (m->prefix && !m->suffix) GSF__TRY(gsf__sp_put(run, " ", 1));
    while (left) {
        gsf__sp_step s = gsf__sp_next(m, text, left);
        for (; after_space && s.size && s.text[0] == ' '; s.size--) s.text++;
        GSF__TRY(gsf__sp_put(run, s.text, s.size));
        if (s.size) after_space = m->trim && s.text[s.size - 1] == ' ';
        text += s.used;
        left -= s.used;
    }
    while (m->trim && run->size >= space_size &&
           memcmp(run->normal + run->size - space_size, space, space_size) == 0)
        run->size -= space_size;
    return m->prefix && m->suffix ? gsf__sp_put(run, " ", 1) : GSF_OK;
}

// ---- segmenting

static void gsf__sp_offer(gsf__sp_best* best, float score, uint32_t start, int32_t id) {
    if (best->id >= 0 && !(score > best->score)) return; // on ties the first one wins
    best->score = score;
    best->start = start;
    best->id = id;
}

// Subtracts the score at `at` from all scores from there on, as floats lose precision when the sums grow large.
static void gsf__sp_rebase(gsf__sp_run* run, size_t at, size_t reached) {
    const float base = run->best[at].score;
    for (size_t i = at; i <= reached; i++)
        if (i == at || run->best[i].id >= 0) run->best[i].score -= base;
}

// Viterbi over the bytes of run->normal. Scores are summed in float and rebased exactly where sentencepiece 0.2.3 does
// it, since rounding decides between segmentations of nearly equal score.
static void gsf__sp_spell(gsf__sp_run* run) {
    // bytes of a character, by its upper four bits
    static const unsigned char widths[17] = "\1\1\1\1\1\1\1\1\1\1\1\1\2\2\3\4";
    const gsf__sp_model* m = run->m;
    const unsigned char* text = (const unsigned char*)run->normal;
    const size_t n = run->size;
    for (size_t i = 0; i <= n; i++) run->best[i].id = -1;
    run->best[0].score = 0.0f;
    size_t reached = 0;
    for (size_t at = 0, width; at < n; at += width) {
        if (fabsf(run->best[at].score) > 100000.0f) gsf__sp_rebase(run, at, reached);
        const float here = run->best[at].score;
        const gsf__sp_node* node = m->pieces;
        int known = 0; // this character on its own is a piece
        width = widths[text[at] >> 4];
        if (width > n - at) width = n - at;
        for (size_t k = at; k < n && (node = gsf__sp_child(m->pieces, node, text[k])) != NULL; k++) {
            const int type = node->id < 0 ? 0 : m->types[node->id];
            const size_t length = k + 1 - at;
            if (type != GSF__SP_NORMAL && type != GSF__SP_USER) continue;
            const float score = type == GSF__SP_USER ? (float)(0.1 * (double)(length - 1)) : m->scores[node->id];
            if (reached < k + 1) reached = k + 1;
            gsf__sp_offer(&run->best[k + 1], score + here, (uint32_t)at, node->id);
            known |= length == width;
        }
        if (!known) {
            if (reached < at + width) reached = at + width;
            gsf__sp_offer(&run->best[at + width], m->unknown_score + here, (uint32_t)at, m->unknown_id);
        }
    }
    for (size_t end = n; end > 0; end = run->best[end].start) run->best[run->best[end].start].next = (uint32_t)end;
}

// Encodes a part of the text that contains no added tokens.
static gsf_result gsf__sp_encode(gsf__sp_run* run, const char* text, size_t size) {
    const gsf__sp_model* m = run->m;
    GSF__TRY(gsf__sp_normalize(run, text, size));
    GSF__TRY(gsf__reserve(run->ctx, (void**)&run->best, &run->best_capacity, 0, run->size + 1, sizeof *run->best));
    gsf__sp_spell(run);
    for (size_t at = 0, end; at < run->size; at = end) {
        end = run->best[at].next;
        int32_t id = run->best[end].id;
        if (id == m->unknown_id && m->byte_fallback) {
            for (size_t i = at; i < end; i++)
                GSF__TRY(gsf__nn_emit(run->ctx, &run->out, m->bytes[(unsigned char)run->normal[i]]));
            continue;
        }
        // merge consecutive unknowns; their text may be a piece excluded from segmentation, such as a control
        if (id == m->unknown_id) {
            while (end < run->size && run->best[run->best[end].next].id == id) end = run->best[end].next;
            id = gsf__sp_find(m->pieces, run->normal + at, end - at);
            if (id < 0) id = m->unknown_id;
        }
        GSF__TRY(gsf__nn_emit(run->ctx, &run->out, id));
    }
    return GSF_OK;
}

// ---- added tokens in a text

// Bytes of the leading white space character, as defined by Python's str.isspace; 0: none.
static size_t gsf__sp_white(const char* text, size_t left) {
    const unsigned char* p = (const unsigned char*)text;
    const size_t size = gsf__utf8_size(p, left);
    if (size == 1) return (p[0] >= 9 && p[0] <= 13) || (p[0] >= 28 && p[0] <= 32);
    if (size == 2) return p[0] == 0xc2 && (p[1] == 0x85 || p[1] == 0xa0) ? 2 : 0;
    if (size != 3) return 0;
    const unsigned c = (p[0] & 15u) << 12 | (p[1] & 63u) << 6 | (p[2] & 63u);
    return c == 0x1680 || (c >= 0x2000 && c <= 0x200a) || c == 0x2028 || c == 0x2029 || c == 0x202f || c == 0x205f ||
           c == 0x3000 ? 3 : 0;
}

static size_t gsf__sp_white_before(const char* text, size_t end) { // bytes of the trailing white space character
    for (size_t size = 1; size <= 3 && size <= end; size++)
        if (gsf__sp_white(text + end - size, size) == size) return size;
    return 0;
}

static gsf_result gsf__sp_encode_all(gsf__sp_run* run, const char* text, size_t size) {
    size_t from = 0; // end of the last added token
    for (size_t at = 0; at <= size; at++) {
        size_t end = at, white;
        const int32_t place = at < size ? gsf__sp_longest(run->m->added, NULL, text + at, size - at, &white) : -1;
        const gsf__sp_added* found = place >= 0 ? &run->m->added_list[place] : NULL;
        if (at < size && !found) continue;
        while (found && found->trim_left && end > from && (white = gsf__sp_white_before(text + from, end - from)) != 0)
            end -= white;
        if (end > from) GSF__TRY(gsf__sp_encode(run, text + from, end - from));
        if (!found) break;
        GSF__TRY(gsf__nn_emit(run->ctx, &run->out, found->id));
        from = at + found->size;
        while (found->trim_right && (white = gsf__sp_white(text + from, size - from)) != 0) from += white;
        at = from - 1;
    }
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_encode_text(gsf_context* ctx, const gsf_nn_tokenizer* tokenizer, const char* text,
                                      size_t size, int32_t* ids, size_t room, size_t* count) {
    gsf__sp_run run;
    memset(&run, 0, sizeof run);
    run.ctx = ctx;
    run.m = (const gsf__sp_model*)tokenizer->model;
    const gsf_result result = gsf__sp_encode_all(&run, text, size);
    const int32_t end = tokenizer->end_id;
    // transformers' T5Tokenizer appends no end if there is one already
    const size_t made = run.out.count, all = made + !(made && run.out.ids[made - 1] == end);
    if (result == GSF_OK && count) *count = all;
    if (result == GSF_OK && room) {
        size_t n = all <= room ? made : room - 1;
        for (size_t i = 0; i < n; i++) ids[i] = run.out.ids[i];
        if (!(n && ids[n - 1] == end)) ids[n++] = end;
        for (; n < room; n++) ids[n] = tokenizer->pad_id;
    }
    gsf_free(ctx, run.normal);
    gsf_free(ctx, run.best);
    gsf_free(ctx, run.out.ids);
    return result;
}

// ---- >>nn t5 --------------------------------------------------------------------

typedef struct gsf__t5_nets { // pointed to by gsf_nn_t5.nets
    gsf__nn_block_sizes sizes;
    gsf__nn_block* blocks;
    const gsf_nn_tensor *embedding, *positions; // (buckets, heads), shared by all blocks
    gsf__nn_layer norm;
} gsf__t5_nets;

static const gsf__nn_entry gsf__t5_block_entries[] = { // below encoder.block.N.
    {"layer.0.layer_norm", "d", GSF__NN_BLOCK_AS(norm1, GSF__NN_WEIGHT, 0)},
    {"layer.0.SelfAttention.q", "id", GSF__NN_BLOCK_AS(q, GSF__NN_WEIGHT, 0)},
    {"layer.0.SelfAttention.k", "id", GSF__NN_BLOCK_AS(k, GSF__NN_WEIGHT, 0)},
    {"layer.0.SelfAttention.v", "id", GSF__NN_BLOCK_AS(v, GSF__NN_WEIGHT, 0)},
    {"layer.0.SelfAttention.o", "di", GSF__NN_BLOCK_AS(out, GSF__NN_WEIGHT, 0)},
    {"layer.1.layer_norm", "d", GSF__NN_BLOCK_AS(norm2, GSF__NN_WEIGHT, 0)},
    {"layer.1.DenseReluDense.wi_0", "md", GSF__NN_BLOCK_AS(gate, GSF__NN_WEIGHT, 0)},
    {"layer.1.DenseReluDense.wi_1", "md", GSF__NN_BLOCK_AS(up, GSF__NN_WEIGHT, 0)},
    {"layer.1.DenseReluDense.wo", "dm", GSF__NN_BLOCK_AS(down, GSF__NN_WEIGHT, 0)},
    GSF__NN_END,
};

#define GSF__T5_AT(member) offsetof(gsf__t5_nets, member), GSF__NN_WEIGHT, 0
static const gsf__nn_entry gsf__t5_entries[] = { // letters: d width, v vocabulary, u buckets, h heads
    {"shared", "vd", GSF__T5_AT(embedding)},
    {"encoder.block.0.layer.0.SelfAttention.relative_attention_bias", "uh", GSF__T5_AT(positions)},
    {"encoder.final_layer_norm", "d", GSF__T5_AT(norm)},
    GSF__NN_END,
};
#undef GSF__T5_AT

static gsf__nn_sizes gsf__t5_sizes(const gsf_nn_t5* c) {
    const gsf__nn_sizes sizes = {{{'d', c->width}, {'v', c->vocabulary}, {'u', c->buckets}, {'h', c->heads}}};
    return sizes;
}

static gsf__nn_block_sizes gsf__t5_block_sizes(const gsf_nn_t5* c) {
    gsf__nn_block_sizes s;
    memset(&s, 0, sizeof s);
    s.width = c->width;
    s.mlp = c->hidden;
    s.heads = c->heads;
    s.head_dim = c->head_dim;
    s.eps = (float)c->norm_eps;
    s.activation = GSF__NN_GELU_TANH;
    s.rms = s.gated = 1;
    return s;
}

static gsf_result gsf__t5_bind(gsf__nn_loader* loader, void* network) {
    gsf_nn_t5* c = (gsf_nn_t5*)network;
    const gsf__nn_sizes sizes = gsf__t5_sizes(c);
    gsf__t5_nets* nets = (gsf__t5_nets*)gsf_alloc_zeroed(loader->ctx, 1, sizeof *nets);
    c->nets = nets;
    if (!nets) return GSF_ERROR_OUT_OF_MEMORY;
    nets->sizes = gsf__t5_block_sizes(c);
    GSF__TRY(gsf__nn_bind(loader, &sizes, gsf__t5_entries, "", nets));
    gsf__nn_ignore(loader, "encoder.embed_tokens.weight"); // some files store the shared table twice
    return gsf__nn_bind_blocks(loader, &nets->sizes, gsf__t5_block_entries, "encoder.block.", c->layers, &nets->blocks);
}

static gsf_result gsf__t5_read_config(const gsf__nn_config* file, void* network) {
    gsf_nn_t5* c = (gsf_nn_t5*)network;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT("d_model", c->width, 1, 1 << 20), GSF__KEY_INT("d_kv", c->head_dim, 1, 1024),
        GSF__KEY_INT("num_heads", c->heads, 1, 1024), GSF__KEY_INT("d_ff", c->hidden, 1, 1 << 20),
        GSF__KEY_INT("num_layers", c->layers, 1, 1024), GSF__KEY_INT("vocab_size", c->vocabulary, 1, INT32_MAX),
        GSF__KEY_INT_OR("relative_attention_num_buckets", c->buckets, 32, 4, 1 << 16),
        GSF__KEY_INT_OR("relative_attention_max_distance", c->max_distance, 128, 1, 1 << 24),
        GSF__KEY_REAL_OR("layer_norm_epsilon", c->norm_eps, 1e-6, 1e-12, 1.0),
        // T5 v1.0 has relu and no gate, which is not supported
        GSF__KEY_WORD_IS("feed_forward_proj", NULL, "gated-gelu"),
        GSF__KEY_WORD_IS("dense_act_fn", "gelu_new", "gelu_new")};
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    if (c->buckets % 4 || c->max_distance <= c->buckets / 4)
        return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s: %d buckets for relative positions up to %d",
                        file->json.name, (int)c->buckets, (int)c->max_distance);
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_load_t5(gsf_context* ctx, const char* folder, gsf_nn_t5* out) {
    memset(out, 0, sizeof *out);
    const gsf_result result =
        gsf__nn_open_network(ctx, folder, "model", gsf__t5_read_config, gsf__t5_bind, out, &out->weights);
    if (result) gsf_nn_destroy_t5(ctx, out);
    return result;
}

GSF_API void gsf_nn_destroy_t5(gsf_context* ctx, gsf_nn_t5* t5) {
    gsf__t5_nets* nets = (gsf__t5_nets*)t5->nets;
    if (nets) gsf_free(ctx, nets->blocks);
    gsf_free(ctx, nets);
    gsf_nn_destroy_weights(ctx, &t5->weights);
    memset(t5, 0, sizeof *t5);
}

// ---- relative position bias

// Bucket of the offset key - query: the upper half of the buckets is for keys after the query. Within a half, the lower
// half of the buckets are exact distances, the others logarithmic up to max_distance. Computed in float, as rounding
// matters. (modeling_t5.py _relative_position_bucket)
static int32_t gsf__t5_bucket(const gsf_nn_t5* c, int64_t offset) {
    const int32_t side = c->buckets / 2, exact = side / 2;
    const int64_t distance = offset < 0 ? -offset : offset;
    int64_t bucket = distance;
    if (distance >= exact) {
        const float spread = (float)log((double)c->max_distance / exact);
        bucket = exact + (int64_t)(logf((float)distance / (float)exact) / spread * (float)(side - exact));
        if (bucket > side - 1) bucket = side - 1;
    }
    return (int32_t)bucket + (offset > 0 ? side : 0);
}

// Fills bias (heads, tokens, tokens), which all blocks share; scratch: 2 tokens + buckets * heads floats.
static void gsf__t5_fill_bias(const gsf_nn_t5* c, const gsf_nn_tensor* positions, int64_t tokens, float* scratch,
                              float* bias) {
    float *line = scratch, *table = scratch + 2 * tokens; // line: indexed by key - query + tokens - 1
    gsf_nn_convert_tensor(positions, 0, positions->count, table);
    for (int64_t h = 0; h < c->heads; h++) {
        for (int64_t i = 0; i < 2 * tokens - 1; i++) line[i] = table[gsf__t5_bucket(c, i + 1 - tokens) * c->heads + h];
        for (int64_t q = 0; q < tokens; q++, bias += tokens)
            memcpy(bias, line + tokens - 1 - q, (size_t)tokens * sizeof(float));
    }
}

// ---- forward pass

// Divides `memory` into buffers; NULL: only counts the floats needed.
static size_t gsf__t5_lay_out(gsf__nn_run* run, const gsf_nn_t5* c, const gsf_nn_t5_desc* in, float** x, float** bias,
                              float* memory) {
    gsf__nn_arena arena = {memory, 0};
    const gsf__nn_block_sizes s = gsf__t5_block_sizes(c);
    const int64_t rows = (int64_t)in->batch * in->tokens, inner = (int64_t)c->heads * c->head_dim;
    const size_t d = (size_t)c->width, n = (size_t)in->tokens, heads = (size_t)c->heads;
    const size_t scratch = 2 * n + (size_t)c->buckets * heads; // for gsf__t5_fill_bias
    const size_t wide = gsf__nn_larger(gsf__nn_wide(&s, rows, rows), scratch);
    run->wide_count = (int64_t)wide;
    run->vectors_size = d;
    *x = gsf__nn_share(&arena, gsf__nn_product((size_t)rows, d));
    run->normed = gsf__nn_share(&arena, gsf__nn_product((size_t)rows, gsf__nn_larger(d, (size_t)inner)));
    run->wide = gsf__nn_share(&arena, wide);
    *bias = gsf__nn_share(&arena, gsf__nn_product(gsf__nn_product(n, n), heads));
    run->vectors = gsf__nn_share(&arena, d);
    return arena.used;
}

// Peak memory in bytes (in addition to out, mapped weights and about 70 MB of kernel scratch) and floating-point
// operations of a gsf_nn_encode_t5 call. T5-XXL with two prompts of 226 tokens: 65 MB, 4.2e12 operations.
static void gsf__nn_query_t5(const gsf_nn_t5* t5, const gsf_nn_t5_desc* input, double* bytes, double* flops) {
    const gsf__nn_block_sizes s = gsf__t5_block_sizes(t5);
    gsf__nn_run run;
    float *x, *bias;
    *bytes = (double)gsf__t5_lay_out(&run, t5, input, &x, &bias, NULL) * sizeof(float);
    *flops = t5->layers * gsf__nn_block_flops(&s, input->batch, input->tokens);
}

static gsf_result gsf__t5_forward(gsf__nn_run* run, const gsf_nn_t5* c, const gsf_nn_t5_desc* in, float* x, float* bias,
                                  float* out) {
    const gsf__t5_nets* nets = (const gsf__t5_nets*)c->nets;
    const int64_t d = c->width, rows = (int64_t)in->batch * in->tokens;
    for (int64_t r = 0; r < rows; r++) gsf_nn_convert_tensor(nets->embedding, (int64_t)in->ids[r] * d, d, x + r * d);
    GSF__TRY(gsf__nn_check(run, "the embedding", "shared.", x, rows * d));
    gsf__nn_reveal(run, x, 0, in->batch, in->tokens, d, "embed");
    gsf__t5_fill_bias(c, nets->positions, in->tokens, run->wide, bias);
    run->sizes = &nets->sizes;
    run->bias = bias;
    run->scale = 1.0f; // T5 does not scale its logits
    run->steps = c->layers;
    for (int32_t i = 0; i < c->layers; i++) {
        snprintf(run->label, sizeof run->label, "block%d.", (int)i);
        GSF__TRY(gsf__nn_block_forward(run, &nets->blocks[i], i, x, in->batch, in->tokens));
        gsf__nn_reveal(run, x, 0, in->batch, in->tokens, d, "out");
        GSF__TRY(gsf__nn_end_block(run, "encoder.block.", i, x, rows * d));
    }
    gsf__nn_rms_norm(run->ctx, x, rows, d, gsf__nn_widen(run, nets->norm.weight, 0), nets->sizes.eps, out);
    return gsf__nn_check(run, "the last norm", "encoder.final", out, rows * d);
}

GSF_API gsf_result gsf_nn_encode_t5(gsf_context* ctx, const gsf_nn_t5* t5, const gsf_nn_t5_desc* input, float* out) {
    const int64_t rows = (int64_t)input->batch * input->tokens;
    gsf__nn_run run;
    float *x, *bias;
    memset(&run, 0, sizeof run);
    if (!input->ids || input->batch < 1 || input->tokens < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "t5: no tokens");
    for (int64_t i = 0; i < rows; i++)
        if (input->ids[i] < 0 || input->ids[i] >= t5->vocabulary)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "t5: id %d; the vocabulary has %d", (int)input->ids[i],
                            (int)t5->vocabulary);
    run.ctx = ctx;
    run.name = "t5";
    run.stage = "text";
    run.weights = &t5->weights;
    run.tap = input->_tap;
    const size_t floats = gsf__t5_lay_out(&run, t5, input, &x, &bias, NULL);
    if (floats > SIZE_MAX / 16)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "t5: %d tokens of %d prompts are too many", (int)input->tokens,
                        (int)input->batch);
    float* memory = (float*)gsf_alloc(ctx, floats, sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__t5_lay_out(&run, t5, input, &x, &bias, memory);
    const gsf_result result = gsf__t5_forward(&run, t5, input, x, bias, out);
    if (result) memset(out, 0, (size_t)(rows * t5->width) * sizeof(float));
    gsf__nn_destroy_workspace(ctx, &run.workspace);
    gsf_free(ctx, memory);
    return result;
}

// ---- >>nn vae -------------------------------------------------------------------

// A run keeps few large buffers (gsf__vae_run), each grown to its largest use: three activations (a block's input, the
// middle of its resnet, the result of a shortcut to more channels), one padded frame, the widened weights of one layer.
// Norm and SiLU are applied while a frame is copied into its padded buffer, so that normalized activations exist for
// only three frames, two of which form the cache for the next chunk anyway. The sums of a group norm are accumulated
// while its input is written. With `dry` set the same traversal allocates and computes nothing, but counts bytes and
// operations.

enum { GSF__VAE_ENCODER_FRAMES = 8, GSF__VAE_DECODER_FRAMES = 2 }; // frames per chunk
enum { GSF__VAE_SLOTS = 4, GSF__VAE_INPUT = 3 }; // activation buffers; the last one holds the chunk's input

// A group norm; with y.out > 0 (decoder) a spatial norm: the normalized input times y(z) plus b(z), z the latents.
typedef struct gsf__vae_norm {
    const gsf_nn_tensor *weight, *bias;
    gsf__conv_layer y, b;
    double eps;
} gsf__vae_norm;

typedef struct gsf__vae_resnet { // x + conv2(silu(norm2(conv1(silu(norm1(x))))))
    gsf__vae_norm norm1, norm2;
    gsf__conv_layer conv1, conv2, shortcut; // shortcut.out 0: identity
} gsf__vae_resnet;

typedef struct gsf__vae_block {
    gsf__vae_resnet* resnets;
    int32_t count;
    gsf__conv_layer sampler; // out 0: none; halves the resolution in the encoder, doubles it in the decoder
    int time;                // also halves or doubles the number of frames
} gsf__vae_block;

typedef struct gsf__vae_net { // encoder or decoder
    int decoder;
    int64_t groups;
    gsf__conv_layer conv_in, conv_out;
    gsf__vae_norm norm_out;
    gsf__vae_block blocks[GSF_NN_VAE_LEVELS + 1];
    int32_t block_count, causal_count; // causal_count: layers that cache frames for the next chunk
} gsf__vae_net;

typedef struct gsf__vae_nets {
    gsf__vae_net encoder, decoder;
} gsf__vae_nets;

// ---- loading a model

typedef struct gsf__vae_loader {
    gsf_context* ctx;
    const gsf_nn_vae* vae;
    gsf__nn_loader* tensors;
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
    GSF__TRY(gsf__nn_need(l->tensors, &layer->weight, rank, shape, "%s.weight", name));
    GSF__TRY(gsf__nn_need(l->tensors, &layer->bias, 1, shape, "%s.bias", name));
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
    GSF__TRY(gsf__nn_need(l->tensors, &norm->weight, 1, &channels, "%s%s.weight", name, layer));
    GSF__TRY(gsf__nn_need(l->tensors, &norm->bias, 1, &channels, "%s%s.bias", name, layer));
    norm->eps = l->net->decoder ? 1e-6 : eps; // CogVideoXSpatialNorm3D ignores the config's
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

// Loads `count` resnets, the first of which changes the number of channels.
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
    const gsf_json_value* list = gsf_find_json_member(&config->json, &config->json.values[0], key);
    if (!list || list->type == GSF_JSON_NULL) return GSF_OK;
    int ok = list->type == GSF_JSON_ARRAY && list->count == levels;
    for (uint32_t i = ok ? list->child : 0; i; i = config->json.values[i].next)
        ok = ok && config->json.values[i].type == GSF_JSON_STRING && strcmp(config->json.values[i].string, type) == 0;
    if (ok) return GSF_OK;
    return gsf_fail(config->ctx, GSF_ERROR_UNSUPPORTED, "%s:%u: %s is not %zu times %s", config->json.name,
                    (unsigned)list->offset, key, levels, type);
}

// Missing keys take the defaults of diffusers' AutoencoderKLCogVideoX.
static gsf_result gsf__vae_take_config(const gsf__nn_config* config, void* network) {
    gsf_nn_vae* vae = (gsf_nn_vae*)network;
    static const char classname[] = "AutoencoderKLCogVideoX";
    const gsf__nn_key keys[] = {
        GSF__KEY_WORD_IS("_class_name", classname, classname), GSF__KEY_WORD_IS("act_fn", "silu", "silu"),
        GSF__KEY_FLAG_IS("use_quant_conv", 0, 0), GSF__KEY_FLAG_IS("use_post_quant_conv", 0, 0),
        GSF__KEY_INT_OR("in_channels", vae->in_channels, 3, 1, 64),
        GSF__KEY_INT_OR("out_channels", vae->out_channels, 3, 1, 64),
        GSF__KEY_INT_OR("latent_channels", vae->latent_channels, 16, 1, 1024),
        GSF__KEY_INT_OR("layers_per_block", vae->layers_per_block, 3, 1, 64),
        GSF__KEY_INT_OR("norm_num_groups", vae->norm_groups, 32, 1, 8192),
        GSF__KEY_INT_OR("temporal_compression_ratio", vae->temporal_ratio, 4, 1, 128),
        GSF__KEY_INT_OR("sample_height", vae->sample_height, 480, 1, 1 << 20),
        GSF__KEY_INT_OR("sample_width", vae->sample_width, 720, 1, 1 << 20),
        GSF__KEY_REAL_OR("norm_eps", vae->norm_eps, 1e-6, 0.0, 1.0),
        GSF__KEY_REAL_OR("scaling_factor", vae->scaling_factor, 1.15258426, 1e-6, 1e6)};
    int64_t channels[GSF_NN_VAE_LEVELS];
    size_t levels;
    GSF__TRY(gsf__nn_config_read(config, keys, GSF__COUNT(keys)));
    GSF__TRY(gsf__nn_config_ints(config, "block_out_channels", 1, 8192, GSF_NN_VAE_LEVELS, channels, &levels));
    GSF__TRY(gsf__vae_check_types(config, "down_block_types", "CogVideoXDownBlock3D", levels));
    GSF__TRY(gsf__vae_check_types(config, "up_block_types", "CogVideoXUpBlock3D", levels));
    vae->levels = (int32_t)levels;
    vae->spatial_ratio = 1 << (levels - 1);
    int32_t temporal = 1; // rounded down to a power of two, at most one doubling per sampler
    while (2 * temporal <= vae->temporal_ratio && 2 * temporal <= vae->spatial_ratio) temporal *= 2;
    vae->temporal_ratio = temporal;
    for (size_t i = 0; i < levels; i++) {
        vae->channels[i] = (int32_t)channels[i];
        if (channels[i] % vae->norm_groups != 0)
            return gsf_fail(config->ctx, GSF_ERROR_FORMAT, "%s: %lld channels are not a multiple of norm_num_groups %d",
                            config->json.name, (long long)channels[i], (int)vae->norm_groups);
    }
    return GSF_OK;
}

static gsf_result gsf__vae_bind(gsf__nn_loader* loader, void* network) {
    gsf_nn_vae* vae = (gsf_nn_vae*)network;
    gsf__vae_nets* nets = (gsf__vae_nets*)gsf_alloc_zeroed(loader->ctx, 1, sizeof *nets);
    gsf__vae_loader l = {loader->ctx, vae, loader, NULL};
    if (!nets) return GSF_ERROR_OUT_OF_MEMORY;
    vae->nets = nets;
    l.net = &nets->encoder;
    GSF__TRY(gsf__vae_load_net(&l, 0));
    l.net = &nets->decoder;
    return gsf__vae_load_net(&l, 1);
}

GSF_API gsf_result gsf_nn_load_vae(gsf_context* ctx, const char* folder, gsf_nn_vae* out) {
    memset(out, 0, sizeof *out);
    const gsf_result result = gsf__nn_open_network(ctx, folder, "diffusion_pytorch_model", gsf__vae_take_config,
                                                   gsf__vae_bind, out, &out->weights);
    if (result) gsf_nn_destroy_vae(ctx, out);
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
    gsf_nn_destroy_weights(ctx, &vae->weights);
    memset(vae, 0, sizeof *vae);
}

// ---- a run

typedef struct gsf__vae_buffer {
    float* data;
    size_t size; // bytes
} gsf__vae_buffer;

typedef struct gsf__vae_cache { // the last two input frames of a causal layer, normalized and padded
    gsf__vae_buffer frames[2];
    int last[2]; // indices of the last but one and of the last frame; -1: none yet
} gsf__vae_cache;

typedef struct gsf__vae_map { // an activation (frames, height, width, channels)
    int slot;
    int64_t frames, height, width, channels;
} gsf__vae_map;

// For tests: receives a layer's result (frame -1, in slot layout), or one frame after norm and SiLU (padded). `weight`
// identifies the layer.
typedef struct gsf__vae_watch {
    void (*fn)(void* user, const gsf_nn_tensor* weight, int64_t chunk, const gsf__vae_map* map, int64_t frame,
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
    gsf__vae_cache* caches;  // one per causal layer; with a single chunk all layers share the first
    int32_t cache_at;
    gsf__vae_map z;          // the chunk's latents, for the decoder's spatial norms
    int64_t chunk, chunks, done, total; // done, total: in chunks of all tiles
    const char* stage;
    gsf__vae_watch watch;
} gsf__vae_run;

static gsf_result gsf__vae_grow(gsf__vae_run* run, gsf__vae_buffer* buffer, int64_t count) {
    const size_t size = (size_t)count * sizeof(float); // cannot overflow: gsf__vae_check_size limits it
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

static gsf_result gsf__vae_begin(gsf__vae_run* run) { // sums: (GSF__VAE_SLOTS + 2, groups, 2) doubles
    run->caches = (gsf__vae_cache*)gsf_alloc_zeroed(run->ctx, (size_t)run->net->causal_count, sizeof *run->caches);
    if (!run->caches) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf__vae_grow(run, &run->sums, (GSF__VAE_SLOTS + 2) * run->net->groups * 2 * 2);
}

static int64_t gsf__vae_plane(const gsf__vae_map* map) { return map->height * map->width * map->channels; }
// Sums of a slot's activation; slot GSF__VAE_SLOTS: of one frame, GSF__VAE_SLOTS + 1: of part of a frame.
static double* gsf__vae_sums(const gsf__vae_run* run, int slot) {
    return (double*)(void*)run->sums.data + slot * run->net->groups * 2;
}
static int64_t gsf__vae_groups(const gsf__vae_run* run, int64_t channels) {
    return channels % run->net->groups == 0 ? run->net->groups : 1;
}
static int gsf__vae_free_slot(int a, int b) { // the first slot that is neither a nor b
    int slot = 0;
    while (slot == a || slot == b) slot++;
    return slot;
}

// Reports NaN or infinity in the result of the layer with weight `tensor`, whose name is cut at ".conv.weight".
static gsf_result gsf__vae_fail_nan(const gsf__vae_run* run, const gsf_nn_tensor* tensor) {
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

typedef struct gsf__vae_blend { // table (pixels, 2, channels): turns y and b into scale and shift of the centered input
    float* table;
    const float *scale, *shift; // of the group norm: weight / standard deviation, and bias
    int64_t width, channels;
} gsf__vae_blend;

static void gsf__vae_blend_row(void* arg, size_t row, int32_t worker) {
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

// conv_y and conv_b over the latents, at the latents' resolution: pointwise, so they commute with the nearest resize.
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
        job.in_stride = run->z.width * run->z.channels; // not padded
        job.origin = 0;
        job.out = table + i * c;
        job.ldo = 2 * c;
        job.out_row = run->z.width * job.ldo;
        gsf__conv_frame(run->ctx, &job, NULL);
    }
    gsf__parallel_for(run->ctx, (size_t)(run->z.frames * run->z.height), gsf__vae_blend_row, &blend);
}

// Fills run->table with (mean, scale, shift) per channel and, in the decoder, the table of gsf__vae_blend after them.
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
    gsf_nn_convert_tensor(norm->weight, 0, c, scale);
    gsf_nn_convert_tensor(norm->bias, 0, c, shift);
    // E[x^2] - E[x]^2 in double, of float values: accurate to 1e-8 even for a mean of 1e4 standard deviations
    for (int64_t i = 0; i < c; i++) {
        const double m = sums[i / per * 2] / count, v = sums[i / per * 2 + 1] / count - m * m;
        mean[i] = (float)m;
        scale[i] = (float)((double)scale[i] / sqrt((v > 0.0 ? v : 0.0) + norm->eps));
    }
    if (norm->y.out) gsf__vae_spatial(run, norm, scale, shift, shift + c);
    return GSF_OK;
}

// Latent frame for frame t of n: nearest, but the first frame separately if n is odd.
static int64_t gsf__vae_latent_frame(int64_t t, int64_t n, int64_t latents) {
    if (n % 2 == 0 || n == 1) return t * latents / n;
    return t == 0 ? 0 : 1 + (t - 1) * (latents - 1) / (n - 1);
}

// Copies frame `t` of `in` into `out` with padding, normalized if there is a norm.
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
        fill.table = fill.mean + in->channels; // then shift
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

// Grows the buffers for a layer's result (slot out->slot), weights and sums, and sets up the job. Packs no weights yet.
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

// Keeps the last two frames for the layer's next chunk; if one of them is in the spare buffer it is copied.
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

// A causal layer with optional norm and SiLU before it (NULL: neither); stores the result in out->slot, or adds it.
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
        if (last < 0) before = last = now; // the first frame is its own predecessor
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

// Pointwise shortcut into out->slot; in place, frame by frame, if that is the input's slot (channels do not increase).
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
    job.partial = NULL; // conv2 is added later and computes the sums
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

// Source frame of frame t after temporal doubling; the first frame of an odd clip is not doubled.
static int64_t gsf__vae_double_source(int64_t t, int64_t frames, int time) {
    return !time || frames == 1 ? t : frames % 2 ? (t + 1) / 2 : t / 2;
}

// One frame of gsf__vae_double. `job` is set up for parity (0, 0); its packed weights cover all four parities.
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

// Nearest resize to twice the size and, with `time`, twice the frames, followed by a 2D convolution, which is computed
// once for duplicated frames. The two are fused into four convolutions on the input's grid, one for each parity of the
// output.
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

// With `time`, averages pairs of frames (keeping the first one of an odd clip); then a 2D convolution of stride 2.
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

// Runs one chunk, whose input is in slot GSF__VAE_INPUT.
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

// ---- clips and tiles

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

// Copies frames of a clip, from `first` on, to channels-last layout, or back.
static void gsf__vae_swap(const gsf__vae_planes* clip, int64_t first, int64_t frames, float* last, int back) {
    for (int64_t t = 0; t < frames; t++)
        for (int64_t y = 0; y < clip->height; y++, last += clip->width * clip->channels)
            for (int64_t c = 0; c < clip->channels; c++) {
                float* row = gsf__vae_row(clip, c, first + t, y);
                for (int64_t x = 0; !back && x < clip->width; x++) last[x * clip->channels + c] = row[x];
                for (int64_t x = 0; back && x < clip->width; x++) row[x] = last[x * clip->channels + c];
            }
}

static int64_t gsf__vae_chunk_count(int64_t frames, int decoder) {
    const int64_t per = decoder ? GSF__VAE_DECODER_FRAMES : GSF__VAE_ENCODER_FRAMES;
    return frames < per ? 1 : frames / per;
}

// Frames of chunk k; the first chunk also takes the remainder.
static int64_t gsf__vae_chunk_frames(int64_t frames, int decoder, int64_t k) {
    const int64_t per = decoder ? GSF__VAE_DECODER_FRAMES : GSF__VAE_ENCODER_FRAMES;
    if (frames < per) return frames;
    return k == 0 ? per + frames % per : per;
}

static int64_t gsf__vae_out_frames(const gsf_nn_vae* vae, int64_t frames, int decoder) {
    int64_t sum = 0;
    const int64_t chunks = gsf__vae_chunk_count(frames, decoder);
    for (int64_t k = 0; k < 2 && k < chunks; k++) { // all chunks except the first have the same size
        int64_t n = gsf__vae_chunk_frames(frames, decoder, k);
        for (int32_t ratio = vae->temporal_ratio; ratio > 1; ratio /= 2) {
            if (!decoder) n = (n + 1) / 2;
            else if (n > 1) n = 2 * n - n % 2;
        }
        sum += k ? n * (chunks - 1) : n;
    }
    return sum;
}

// Runs all chunks of a clip or tile.
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
        if (!run->dry) gsf__vae_swap(in, first, x.frames, run->slots[GSF__VAE_INPUT].data, 0);
        GSF__TRY(gsf__vae_chunk(run, &x, &y));
        if (!run->dry) {
            gsf__vae_swap(out, out_first, y.frames, run->slots[y.slot].data, 1);
            gsf__progress(run->ctx, run->stage, (double)++run->done, (double)run->total);
        }
        first += x.frames;
        out_first += y.frames;
    }
    return GSF_OK;
}

typedef struct gsf__vae_plan { // tiling of a task; without tiling a single tile
    int64_t out_frames, out_height, out_width, out_channels;
    int64_t rows, columns;                 // tiles
    int64_t tile[2], step[2];              // height, width of an input tile; distance between tiles
    int64_t out_step[2], blend[2];         // distance and overlap in the output
} gsf__vae_plan;

// int() of a nonnegative Python float.
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
    // keeps all sizes below 2^63
    if ((double)frames * ((double)height + 2.0) * ((double)width + 2.0) * scale * widest > 1e15)
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
                        "tiling: %lld x %lld leaves a last tile of %lld x %lld, which is not a multiple of %lld",
                        (long long)width, (long long)height, (long long)right, (long long)bottom, (long long)ratio);
    *plan = tiled;
    return GSF_OK;
}

// Cross-fades b's first rows with a's last ones, in place. `across`: columns instead of rows.
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

static void gsf__vae_copy(const gsf__vae_planes* from, const gsf__vae_planes* to) { // copies the common area
    const int64_t height = from->height < to->height ? from->height : to->height;
    const int64_t width = from->width < to->width ? from->width : to->width;
    for (int64_t c = 0; c < to->channels; c++)
        for (int64_t t = 0; t < to->frames; t++)
            for (int64_t y = 0; y < height; y++)
                memcpy(gsf__vae_row(to, c, t, y), gsf__vae_row(from, c, t, y), (size_t)width * sizeof(float));
}

// Height (axis 0) or width (axis 1) of tile k of an input of `size`.
static int64_t gsf__vae_tile_size(const gsf__vae_plan* plan, int axis, int64_t size, int64_t k) {
    const int64_t left = size - k * plan->step[axis];
    return left < plan->tile[axis] ? left : plan->tile[axis];
}

// Runs the tiles one by one, each over all frames. A tile is blended with the already blended tiles above and to its
// left, so two rows of tiles are kept: tiles (2, columns).
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
    // The input is only read, but gsf__vae_planes is not const.
    const gsf__vae_planes from =
        gsf__vae_wrap((float*)(uintptr_t)in, task->decoder ? vae->latent_channels : vae->in_channels, task->frames,
                      task->height, task->width);
    const gsf__vae_planes to = gsf__vae_wrap(out, plan->out_channels, plan->out_frames, plan->out_height, plan->out_width);
    if (plan->rows * plan->columns == 1) return gsf__vae_clip(run, &from, &to);
    task->tiles = (gsf__vae_buffer*)gsf_alloc_zeroed(run->ctx, (size_t)plan->columns * 2, sizeof *task->tiles);
    if (!task->tiles) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf__vae_tiles(run, plan, &from, &to, task->tiles);
}

// Runs the task; with in == NULL it only counts *flops and *bytes.
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
    const int64_t at = gsf__nn_find_not_finite(ctx, x, channels * frames * height * width);
    if (at < 0) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: NaN or infinity in channel %lld, frame %lld, row %lld, column %lld", what,
                    (long long)(at / (frames * height * width)), (long long)(at / (height * width) % frames),
                    (long long)(at / width % height), (long long)(at % width));
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
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: needs %.0f MiB, but only %.0f are allowed", stage,
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

GSF_API gsf_result gsf_nn_encode_vae(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                     const float* video, int64_t frames, int64_t height, int64_t width, float* mean,
                                     float* logvar) {
    return gsf__vae_apply(ctx, vae, 0, desc, video, frames, height, width, NULL, mean, logvar);
}

GSF_API gsf_result gsf_nn_decode_vae(gsf_context* ctx, const gsf_nn_vae* vae, const gsf_nn_vae_desc* desc,
                                     const float* latents, int64_t frames, int64_t height, int64_t width, float* video) {
    return gsf__vae_apply(ctx, vae, 1, desc, latents, frames, height, width, video, NULL, NULL);
}

// ---- >>nn transformer -----------------------------------------------------------

typedef struct gsf__dit_attention { // keys and values: from the sample itself or the references
    gsf__nn_layer q, k, v, out, norm_q, norm_k;
} gsf__dit_attention;

typedef struct gsf__dit_norm { // LayerNorm whose scale, shift and gates depend on the time step
    gsf__nn_layer linear, norm;
} gsf__dit_norm;

typedef struct gsf__dit_block {
    gsf__dit_norm norm1, norm2;
    gsf__dit_attention self, cross;
    gsf__nn_layer norm_cross, up, down; // up, down: feed-forward
} gsf__dit_block;

typedef struct gsf__dit_projector { gsf__nn_layer linear, norm; } gsf__dit_projector;

typedef struct gsf__dit_nets { // pointed to by gsf_nn_transformer.nets
    gsf__dit_block* blocks;
    gsf__nn_quantized* quantized; // one per tensor of the file, empty if not quantized; NULL: no tensor is
    gsf__dit_projector dino, vggt;
    gsf__dit_norm norm_out;
    gsf__nn_layer patch, text, time1, time2, norm_final, out;
    const gsf_nn_tensor* positions;
} gsf__dit_nets;

static int64_t gsf__dit_width(const gsf_nn_transformer* c) { return (int64_t)c->heads * c->head_dim; }

// ---- loading: tables of tensors

#define GSF__DIT_AT(member) GSF__NN_AT(gsf__dit_block, member)
#define GSF__DIT_ATTENTION(prefix, member)                                                           \
    {prefix ".to_q", "dd", offsetof(gsf__dit_block, member.q), GSF__NN_BIASED, 'b'},                 \
    {prefix ".to_k", "dd", offsetof(gsf__dit_block, member.k), GSF__NN_BIASED, 'b'},                 \
    {prefix ".to_v", "dd", offsetof(gsf__dit_block, member.v), GSF__NN_BIASED, 'b'},                 \
    {prefix ".to_out.0", "dd", GSF__DIT_AT(member.out)},                                             \
    {prefix ".norm_q", "h", GSF__DIT_AT(member.norm_q)},                                             \
    {prefix ".norm_k", "h", GSF__DIT_AT(member.norm_k)}

static const gsf__nn_entry gsf__dit_block_entries[] = { // below transformer_blocks.N.
    {"norm1.linear", "mt", GSF__DIT_AT(norm1.linear)},
    {"norm1.norm", "d", GSF__DIT_AT(norm1.norm)},
    {"norm2.linear", "mt", GSF__DIT_AT(norm2.linear)},
    {"norm2.norm", "d", GSF__DIT_AT(norm2.norm)},
    GSF__DIT_ATTENTION("attn1", self),
    GSF__DIT_ATTENTION("attn_cross", cross),
    {"norm_cross", "d", GSF__DIT_AT(norm_cross)},
    {"ff.net.0.proj", "fd", GSF__DIT_AT(up)},
    {"ff.net.2", "df", GSF__DIT_AT(down)},
    GSF__NN_END,
};
#undef GSF__DIT_AT
#undef GSF__DIT_ATTENTION

#define GSF__DIT_AT(member) GSF__NN_AT(gsf__dit_nets, member)
static const gsf__nn_entry gsf__dit_entries[] = {
    {"patch_embed.proj", "dikk", GSF__DIT_AT(patch)},
    {"patch_embed.text_proj", "dx", GSF__DIT_AT(text)},
    {"patch_embed.pos_embedding", "1sd", offsetof(gsf__dit_nets, positions), GSF__NN_TENSOR, 'l'},
    {"time_embedding.linear_1", "td", GSF__DIT_AT(time1)},
    {"time_embedding.linear_2", "tt", GSF__DIT_AT(time2)},
    {"projector_dino.proj", "d?", GSF__DIT_AT(dino.linear)},
    {"projector_dino.norm", "d", GSF__DIT_AT(dino.norm)},
    {"projector_vggt.proj", "d?", GSF__DIT_AT(vggt.linear)},
    {"projector_vggt.norm", "d", GSF__DIT_AT(vggt.norm)},
    {"norm_final", "d", GSF__DIT_AT(norm_final)},
    {"norm_out.linear", "nt", GSF__DIT_AT(norm_out.linear)},
    {"norm_out.norm", "d", GSF__DIT_AT(norm_out.norm)},
    {"proj_out", "pd", GSF__DIT_AT(out)},
    GSF__NN_END,
};
#undef GSF__DIT_AT

// Letters: d width, h head_dim, f 4 width, m 6 width, n 2 width, t time channels, x text channels, i in_channels,
// k patch, p outputs of a token, s text and video tokens of the learned position table, b 0 if q, k, v have no biases,
// l 0 without that table.
static gsf__nn_sizes gsf__dit_tensor_sizes(const gsf_nn_transformer* c) {
    const int64_t d = gsf__dit_width(c), frames = c->temporal_ratio ? (c->sample_frames - 1) / c->temporal_ratio + 1 : 0;
    const int64_t places = c->text_tokens + frames * (c->sample_height / c->patch) * (c->sample_width / c->patch);
    const gsf__nn_sizes sizes = {{{'d', d}, {'h', c->head_dim}, {'f', 4 * d}, {'m', 6 * d}, {'n', 2 * d},
                                  {'t', c->time_channels}, {'x', c->text_channels}, {'i', c->in_channels}, {'k', c->patch},
                                  {'p', (int64_t)c->out_channels * c->patch * c->patch}, {'s', places},
                                  {'b', c->attention_bias}, {'l', c->learned_positions}}};
    return sizes;
}

static gsf_result gsf__dit_read_config(const gsf__nn_config* file, void* network) {
    gsf_nn_transformer* c = (gsf_nn_transformer*)network;
    const gsf__nn_key keys[] = {
        GSF__KEY_INT("num_attention_heads", c->heads, 1, 1024), GSF__KEY_INT("attention_head_dim", c->head_dim, 8, 1024),
        GSF__KEY_INT("num_layers", c->layers, 1, 1024), GSF__KEY_INT("in_channels", c->in_channels, 1, 65536),
        GSF__KEY_INT("out_channels", c->out_channels, 1, 65536),
        GSF__KEY_INT("text_embed_dim", c->text_channels, 1, 1 << 20),
        GSF__KEY_INT("max_text_seq_length", c->text_tokens, 1, 1 << 20),
        GSF__KEY_INT("time_embed_dim", c->time_channels, 1, 1 << 20), GSF__KEY_INT("patch_size", c->patch, 1, 64),
        GSF__KEY_INT("sample_width", c->sample_width, 1, 1 << 16),
        GSF__KEY_INT("sample_height", c->sample_height, 1, 1 << 16),
        GSF__KEY_INT("sample_frames", c->sample_frames, 1, 1 << 16),
        GSF__KEY_INT("temporal_compression_ratio", c->temporal_ratio, 1, 64),
        GSF__KEY_FLAG_OR("attention_bias", c->attention_bias, 1),
        GSF__KEY_FLAG_OR("use_learned_positional_embeddings", c->learned_positions, 0),
        GSF__KEY_FLAG_OR("use_rotary_positional_embeddings", c->rotary_positions, 0),
        GSF__KEY_REAL_OR("norm_eps", c->norm_eps, 1e-5, 1e-12, 1.0),
        GSF__KEY_REAL_OR("spatial_interpolation_scale", c->spatial_scale, 1.875, 1e-3, 1e3),
        GSF__KEY_REAL_OR("temporal_interpolation_scale", c->temporal_scale, 1.0, 1e-3, 1e3),
        GSF__KEY_WORD_IS("activation_fn", "gelu-approximate", "gelu-approximate"),
        GSF__KEY_WORD_IS("timestep_activation_fn", "silu", "silu"), GSF__KEY_FLAG_IS("flip_sin_to_cos", 1, 1),
        GSF__KEY_FLAG_IS("norm_elementwise_affine", 1, 1), GSF__KEY_FLAG_IS("patch_bias", 1, 1),
        GSF__KEY_ABSENT("ofs_embed_dim"), GSF__KEY_ABSENT("patch_size_t")};
    double shift;
    GSF__TRY(gsf__nn_config_read(file, keys, GSF__COUNT(keys)));
    GSF__TRY(gsf__nn_config_number_or(file, "freq_shift", 0.0, -1e3, 1e3, &shift));
    if (shift != 0.0) return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED, "%s: freq_shift is not 0", file->json.name);
    if (c->head_dim % 16 || c->sample_width % c->patch || c->sample_height % c->patch)
        return gsf_fail(file->ctx, GSF_ERROR_UNSUPPORTED,
                        "%s: attention_head_dim %d is not a multiple of 16, or the sample size not of the patch size",
                        file->json.name, (int)c->head_dim);
    return GSF_OK;
}

static gsf_result gsf__dit_bind(gsf__nn_loader* loader, void* network) {
    gsf_nn_transformer* net = (gsf_nn_transformer*)network;
    const gsf__nn_sizes sizes = gsf__dit_tensor_sizes(net);
    gsf__dit_nets* nets = (gsf__dit_nets*)gsf_alloc_zeroed(loader->ctx, 1, sizeof *nets);
    net->nets = nets;
    if (!nets) return GSF_ERROR_OUT_OF_MEMORY;
    nets->blocks = (gsf__dit_block*)gsf_alloc_zeroed(loader->ctx, (size_t)net->layers, sizeof *nets->blocks);
    if (!nets->blocks) return GSF_ERROR_OUT_OF_MEMORY;
    GSF__TRY(gsf__nn_bind(loader, &sizes, gsf__dit_entries, "", nets));
    if (!net->learned_positions) gsf__nn_ignore(loader, "patch_embed.pos_embedding"); // computed instead
    net->dino_channels = (int32_t)nets->dino.linear.weight->shape[1];
    net->vggt_channels = (int32_t)nets->vggt.linear.weight->shape[1];
    return gsf__nn_bind_each(loader, &sizes, gsf__dit_block_entries, "transformer_blocks.", net->layers,
                             sizeof *nets->blocks, nets->blocks);
}

GSF_API void gsf_nn_destroy_transformer(gsf_context* ctx, gsf_nn_transformer* transformer) {
    gsf__dit_nets* nets = (gsf__dit_nets*)transformer->nets;
    if (nets) {
        for (size_t i = 0; nets->quantized && i < transformer->weights.tensor_count; i++)
            gsf__nn_destroy_quantized(ctx, &nets->quantized[i]);
        gsf_free(ctx, nets->quantized);
        gsf_free(ctx, nets->blocks);
    }
    gsf_free(ctx, nets);
    gsf_nn_destroy_weights(ctx, &transformer->weights);
    memset(transformer, 0, sizeof *transformer);
}

GSF_API gsf_result gsf_nn_quantize_transformer(gsf_context* ctx, gsf_nn_transformer* transformer, size_t* bytes) {
    gsf__dit_nets* nets = (gsf__dit_nets*)transformer->nets;
    const gsf_nn_weights* w = &transformer->weights;
    size_t total = 0;
    if (!nets->quantized)
        nets->quantized = (gsf__nn_quantized*)gsf_alloc_zeroed(ctx, w->tensor_count, sizeof *nets->quantized);
    if (!nets->quantized) return GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < transformer->layers; i++) {
        const gsf__dit_block* b = &nets->blocks[i];
        const gsf_nn_tensor* const layers[] = {
            b->self.q.weight, b->self.k.weight, b->self.v.weight, b->self.out.weight, b->cross.q.weight,
            b->cross.k.weight, b->cross.v.weight, b->cross.out.weight, b->up.weight, b->down.weight};
        for (size_t k = 0; k < GSF__COUNT(layers); k++) {
            gsf__nn_quantized* q = &nets->quantized[layers[k] - w->tensors];
            if (!q->data) GSF__TRY(gsf__nn_quantize_weight(ctx, layers[k], 0, q));
            total += q->bytes;
        }
        GSF__TRY(gsf__check_cancel(ctx));
        gsf__progress(ctx, "quantize", i + 1, transformer->layers);
    }
    if (bytes) *bytes = total;
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_load_transformer(gsf_context* ctx, const char* folder, gsf_nn_transformer* out) {
    memset(out, 0, sizeof *out);
    const gsf_result result = gsf__nn_open_network(ctx, folder, "diffusion_pytorch_model", gsf__dit_read_config,
                                                   gsf__dit_bind, out, &out->weights);
    if (result) gsf_nn_destroy_transformer(ctx, out);
    return result;
}

// ---- forward pass

typedef struct gsf__dit_run {
    gsf__nn_run nn;
    const gsf_nn_transformer* net;
    const gsf__dit_nets* nets;
    const gsf_nn_transformer_desc* in;
    int64_t width, text, video, tokens; // tokens = text + video: rows per sample
    float* x;       // (batch, tokens, width): the residual stream, text first
    float* normed;  // (tokens, width)
    // 3 x (rows, width), rows: the larger of tokens and reference tokens; also the feed-forward's hidden rows
    float* qkv;
    int64_t qkv_rows;
    float* time;    // (batch, time_channels): SiLU of the time embedding
    float* modulation; // (6 width)
    float *cos, *sin; // (video, head_dim) or NULL
    float* probe;   // (tokens, width): output of a gated layer before the gate; only with a tap
} gsf__dit_run;

static gsf_result gsf__dit_linear(gsf__dit_run* run, const gsf__nn_layer* layer, const float* x, int64_t rows, float* y) {
    return gsf__nn_linear(&run->nn, layer, GSF__NN_LINEAR, x, rows, y, 0);
}

// x += gate * (h w^T + b); gate NULL: 1. Also stores the ungated output in `probe` unless that is NULL.
static gsf_result gsf__dit_add(gsf__dit_run* run, const gsf__nn_layer* layer, const float* gate, const float* h, int64_t rows,
                               float* x, float* probe) {
    if (probe) GSF__TRY(gsf__dit_linear(run, layer, h, rows, probe));
    return gsf__nn_add(&run->nn, layer, gate, h, rows, x);
}

static void gsf__dit_norm_heads(gsf__dit_run* run, const gsf__nn_layer* norm, int rotate, float* x, int64_t rows) {
    const gsf_nn_transformer* c = run->net;
    const float eps = 1e-6f; // hard-coded in the GSFixer release
    gsf__nn_norm_heads(&run->nn, norm, eps, c->heads, c->head_dim, rotate ? run->cos : NULL, rotate ? run->sin : NULL,
                       rotate ? run->text : 0, x, rows, run->width);
}

static gsf_result gsf__dit_attend(gsf__dit_run* run, int64_t queries, int64_t keys, const float* q, const float* k,
                                  const float* v) { // result in run->normed
    gsf__nn_attention_desc a;
    memset(&a, 0, sizeof a);
    a.queries = queries;
    a.keys = keys;
    a.heads = run->net->heads;
    a.head_dim = run->net->head_dim;
    a.q = q;
    a.k = k;
    a.v = v;
    a.out = run->normed;
    return gsf__nn_attend(&run->nn, &a, 1);
}

// LN(x) (1 + scale) + shift for the text and the video tokens of a sample, each with its own shift and scale. The
// modulation has six parts: shift, scale, gate of the video, then those of the text.
static gsf_result gsf__dit_modulate(gsf__dit_run* run, const char* name, int32_t row, const gsf__dit_norm* norm) {
    const int64_t d = run->width;
    const float *x = run->x + row * run->tokens * d, *time = run->time + row * run->net->time_channels;
    const float eps = (float)run->net->norm_eps;
    float *m = run->modulation, *video = run->normed + run->text * d;
    GSF__TRY(gsf__dit_linear(run, &norm->linear, time, 1, m));
    const gsf__nn_vectors v = gsf__nn_widen_layer(&run->nn, &norm->norm);
    gsf__nn_layer_norm_modulated(run->nn.ctx, x, run->text, d, v.weight, v.bias, eps, m + 4 * d, m + 3 * d,
                                 run->normed);
    gsf__nn_layer_norm_modulated(run->nn.ctx, x + run->text * d, run->video, d, v.weight, v.bias, eps, m + d, m, video);
    gsf__nn_reveal(&run->nn, video, row, 1, run->video, d, "%s.0", name);
    gsf__nn_reveal(&run->nn, run->normed, row, 1, run->text, d, "%s.1", name);
    gsf__nn_reveal(&run->nn, m + 2 * d, row, 1, 1, d, "%s.2", name);
    gsf__nn_reveal(&run->nn, m + 5 * d, row, 1, 1, d, "%s.3", name);
    return GSF_OK;
}

enum { GSF__DIT_TEXT_GATE = 5, GSF__DIT_VIDEO_GATE = 2 }; // indices of parts of the modulation

// x += gate * attention over text and video tokens together.
static gsf_result gsf__dit_self_attention(gsf__dit_run* run, int32_t row, const gsf__dit_attention* a) {
    const int64_t d = run->width, n = run->tokens;
    const float *text_gate = run->modulation + GSF__DIT_TEXT_GATE * d, *gate = run->modulation + GSF__DIT_VIDEO_GATE * d;
    float *q = run->qkv, *k = q + run->qkv_rows * d, *v = k + run->qkv_rows * d, *video = run->normed + run->text * d;
    float *x = run->x + row * n * d, *probe = run->probe ? run->probe + run->text * d : NULL;
    GSF__TRY(gsf__dit_linear(run, &a->q, run->normed, n, q));
    GSF__TRY(gsf__dit_linear(run, &a->k, run->normed, n, k));
    GSF__TRY(gsf__dit_linear(run, &a->v, run->normed, n, v));
    gsf__dit_norm_heads(run, &a->norm_q, 1, q, n);
    gsf__dit_norm_heads(run, &a->norm_k, 1, k, n);
    GSF__TRY(gsf__dit_attend(run, n, n, q, k, v));
    GSF__TRY(gsf__dit_add(run, &a->out, text_gate, run->normed, run->text, x, run->probe));
    GSF__TRY(gsf__dit_add(run, &a->out, gate, video, run->video, x + run->text * d, probe));
    gsf__nn_reveal(&run->nn, probe, row, 1, run->video, d, "attn1.0");
    gsf__nn_reveal(&run->nn, run->probe, row, 1, run->text, d, "attn1.1");
    return GSF_OK;
}

// Keys and values of the references for one block: (2, reference tokens, width).
static gsf_result gsf__dit_reference_kv(gsf__dit_run* run, const gsf__dit_attention* a, const float* references,
                                        float* kv) {
    const int64_t r = run->in->reference_tokens;
    GSF__TRY(gsf__dit_linear(run, &a->k, references, r, kv));
    GSF__TRY(gsf__dit_linear(run, &a->v, references, r, kv + r * run->width));
    gsf__dit_norm_heads(run, &a->norm_k, 0, kv, r);
    return GSF_OK;
}

// Video tokens attend to the references: x += attention(norm(x), references), without gate or rotation.
static gsf_result gsf__dit_cross_attention(gsf__dit_run* run, int32_t row, int32_t index, const gsf__dit_block* block) {
    const gsf__dit_attention* a = &block->cross;
    const int64_t d = run->width, r = run->in->reference_tokens;
    float* x = run->x + (row * run->tokens + run->text) * d;
    float *q = run->qkv, *normed = run->normed, *kv = run->qkv + run->qkv_rows * d;
    const int32_t source = run->in->reference_batch == 1 ? 0 : row;
    int ready = source < row; // row 0 has computed what all rows share
    if (run->in->reference_kv) {
        kv = run->in->reference_kv + ((int64_t)index * run->in->reference_batch + source) * 2 * r * d;
        ready = ready || run->in->reference_kv_ready;
    }
    if (!ready) GSF__TRY(gsf__dit_reference_kv(run, a, run->in->references + source * r * d, kv));
    gsf__nn_norm(&run->nn, &block->norm_cross, (float)run->net->norm_eps, x, run->video, normed);
    gsf__nn_reveal(&run->nn, normed, row, 1, run->video, d, "norm_cross");
    GSF__TRY(gsf__dit_linear(run, &a->q, normed, run->video, q));
    gsf__dit_norm_heads(run, &a->norm_q, 0, q, run->video);
    GSF__TRY(gsf__dit_attend(run, run->video, r, q, kv, kv + r * d));
    GSF__TRY(gsf__dit_add(run, &a->out, NULL, normed, run->video, x, run->probe));
    gsf__nn_reveal(&run->nn, run->probe, row, 1, run->video, d, "attn_cross");
    return GSF_OK;
}

// x += gate * down(gelu(up(normed))), in groups of rows whose hidden layer fits in the buffer of q, k and v.
static gsf_result gsf__dit_feed_forward(gsf__dit_run* run, int32_t row, const gsf__dit_block* block) {
    const int64_t d = run->width, most = run->qkv_rows * 3 / 4;
    float* x = run->x + row * run->tokens * d;
    for (int stream = 0; stream < 2; stream++) {
        const int64_t first = stream ? run->text : 0, end = stream ? run->tokens : run->text;
        const float* gate = run->modulation + (stream ? GSF__DIT_VIDEO_GATE : GSF__DIT_TEXT_GATE) * d;
        for (int64_t r = first; r < end; r += most) {
            const int64_t rows = gsf__least(end - r, most);
            const float* from = run->normed + r * d;
            GSF__TRY(gsf__nn_linear(&run->nn, &block->up, GSF__NN_GELU_TANH, from, rows, run->qkv, 0));
            GSF__TRY(gsf__dit_add(run, &block->down, gate, run->qkv, rows, x + r * d,
                                  run->probe ? run->probe + r * d : NULL));
        }
    }
    gsf__nn_reveal(&run->nn, run->probe, row, 1, run->tokens, d, "ff");
    return GSF_OK;
}

// Runs one block on all samples, layer by layer, so that they can share the keys and values of the references.
static gsf_result gsf__dit_block_forward(gsf__dit_run* run, int32_t index) {
    const gsf__dit_block* block = &run->nets->blocks[index];
    const int32_t batch = run->in->batch;
    snprintf(run->nn.label, sizeof run->nn.label, "block%d.", (int)index);
    for (int32_t b = 0; b < batch; b++) {
        GSF__TRY(gsf__dit_modulate(run, "norm1", b, &block->norm1));
        GSF__TRY(gsf__dit_self_attention(run, b, &block->self));
        GSF__TRY(gsf__check_cancel(run->nn.ctx));
    }
    for (int32_t b = 0; b < batch && run->in->references; b++) {
        GSF__TRY(gsf__dit_cross_attention(run, b, index, block));
        GSF__TRY(gsf__check_cancel(run->nn.ctx));
    }
    for (int32_t b = 0; b < batch; b++) {
        GSF__TRY(gsf__dit_modulate(run, "norm2", b, &block->norm2));
        GSF__TRY(gsf__dit_feed_forward(run, b, block));
        GSF__TRY(gsf__check_cancel(run->nn.ctx));
    }
    for (int32_t b = 0; b < batch; b++) {
        const float* x = run->x + b * run->tokens * run->width;
        gsf__nn_reveal(&run->nn, x + run->text * run->width, b, 1, run->video, run->width, "0");
        gsf__nn_reveal(&run->nn, x, b, 1, run->text, run->width, "1");
    }
    run->nn.label[0] = 0;
    return GSF_OK;
}

// ---- input and output layers

// SiLU of the time embedding of each sample.
static gsf_result gsf__dit_embed_time(gsf__dit_run* run) {
    const int64_t d = run->width, t = run->net->time_channels;
    for (int32_t b = 0; b < run->in->batch; b++) {
        float *wave = run->qkv, *hidden = wave + d, *out = run->time + b * t;
        gsf__nn_embed_timestep(run->in->timesteps[b], (int32_t)d, wave);
        gsf__nn_reveal(&run->nn, wave, b, 1, 1, d, "time_proj");
        GSF__TRY(gsf__nn_linear(&run->nn, &run->nets->time1, GSF__NN_SILU, wave, 1, hidden, 0));
        GSF__TRY(gsf__dit_linear(run, &run->nets->time2, hidden, 1, out));
        gsf__nn_reveal(&run->nn, out, b, 1, 1, t, "time_embedding");
        gsf__nn_activate(run->nn.ctx, GSF__NN_SILU, out, t, out);
    }
    return GSF_OK;
}

// Adds position embeddings: the learned table (text and video) for the configured number of frames, otherwise sines and
// cosines (video only), as diffusers' CogVideoXPatchEmbed does.
static gsf_result gsf__dit_add_positions(gsf__dit_run* run) {
    const gsf_nn_transformer* c = run->net;
    const gsf_nn_transformer_desc* in = run->in;
    if (!c->learned_positions && c->rotary_positions) return GSF_OK;
    const int64_t d = run->width;
    const int same_frames = (in->frames - 1) * c->temporal_ratio + 1 == c->sample_frames;
    if (c->learned_positions && same_frames && run->text == c->text_tokens) {
        for (int64_t r = 0; r < run->tokens; r++) { // row by row, as the table may be bf16
            gsf_nn_convert_tensor(run->nets->positions, r * d, d, run->qkv);
            for (int32_t b = 0; b < in->batch; b++)
                for (int64_t i = 0; i < d; i++) run->x[(b * run->tokens + r) * d + i] += run->qkv[i];
        }
        return GSF_OK;
    }
    GSF__TRY(gsf__nn_make_sincos(run->nn.ctx, in->frames, in->height / c->patch, in->width / c->patch, (int32_t)d,
                                 c->spatial_scale, c->temporal_scale, run->qkv));
    for (int32_t b = 0; b < in->batch; b++)
        for (int64_t i = 0; i < run->video * d; i++) run->x[(b * run->tokens + run->text) * d + i] += run->qkv[i];
    return GSF_OK;
}

static gsf_result gsf__dit_embed(gsf__dit_run* run) {
    const gsf_nn_transformer* c = run->net;
    const gsf_nn_transformer_desc* in = run->in;
    const int64_t d = run->width, sample = (int64_t)in->frames * c->in_channels * in->height * in->width;
    for (int32_t b = 0; b < in->batch; b++) {
        float* x = run->x + b * run->tokens * d;
        const float* text = in->text + b * run->text * c->text_channels;
        GSF__TRY(gsf__dit_linear(run, &run->nets->text, text, run->text, x));
        gsf__nn_patch_job job = {in->hidden + b * sample, run->qkv, c->in_channels, in->height, in->width, c->patch, 0,
                                 NULL, NULL};
        gsf__nn_patch(run->nn.ctx, &job, in->frames);
        GSF__TRY(gsf__dit_linear(run, &run->nets->patch, run->qkv, run->video, x + run->text * d));
    }
    GSF__TRY(gsf__dit_add_positions(run));
    gsf__nn_reveal(&run->nn, run->x, 0, in->batch, run->tokens, d, "patch_embed");
    return gsf__nn_check(&run->nn, "the embedding", "patch_embed.", run->x, in->batch * run->tokens * d);
}

// Video tokens to velocities: two LayerNorms in sequence, the second one modulated, then the output projection.
static gsf_result gsf__dit_head(gsf__dit_run* run, int32_t row, float* out) {
    const gsf_nn_transformer* c = run->net;
    const int64_t d = run->width, outputs = (int64_t)c->out_channels * c->patch * c->patch;
    const float eps = (float)c->norm_eps, *x = run->x + (row * run->tokens + run->text) * d;
    const gsf__dit_norm* norm = &run->nets->norm_out;
    float *m = run->modulation, *normed = run->normed;
    gsf__nn_norm(&run->nn, &run->nets->norm_final, eps, x, run->video, normed);
    gsf__nn_reveal(&run->nn, normed, row, 1, run->video, d, "norm_final");
    GSF__TRY(gsf__dit_linear(run, &norm->linear, run->time + row * c->time_channels, 1, m));
    const gsf__nn_vectors v = gsf__nn_widen_layer(&run->nn, &norm->norm);
    gsf__nn_layer_norm_modulated(run->nn.ctx, normed, run->video, d, v.weight, v.bias, eps, m + d, m, normed);
    gsf__nn_reveal(&run->nn, normed, row, 1, run->video, d, "norm_out");
    GSF__TRY(gsf__dit_linear(run, &run->nets->out, normed, run->video, run->qkv));
    gsf__nn_reveal(&run->nn, run->qkv, row, 1, run->video, outputs, "proj_out");
    gsf__nn_patch_job job = {run->qkv, out, c->out_channels, run->in->height, run->in->width, c->patch, 1, NULL, NULL};
    gsf__nn_patch(run->nn.ctx, &job, run->in->frames);
    return GSF_OK;
}

// ---- blocks, and the cache that skips them if they would repeat the previous step

GSF_API void gsf_nn_destroy_block_cache(gsf_context* ctx, gsf_nn_block_cache* cache) {
    gsf_free(ctx, cache->first);
    memset(cache, 0, sizeof *cache);
}

enum { GSF__DIT_CACHE_ROWS = 8 }; // the change is measured on every 8th row only

static gsf_result gsf__dit_open_cache(gsf__dit_run* run, gsf_nn_block_cache* cache) {
    const size_t rows = (size_t)run->in->batch * (size_t)run->tokens, width = (size_t)run->width;
    const size_t sampled = (rows + GSF__DIT_CACHE_ROWS - 1) / GSF__DIT_CACHE_ROWS * width;
    if (cache->size == rows * width) return GSF_OK;
    const float threshold = cache->threshold;
    gsf_nn_destroy_block_cache(run->nn.ctx, cache);
    cache->threshold = threshold;
    cache->first = (float*)gsf_alloc_zeroed(run->nn.ctx, rows * width + 2 * sampled, sizeof(float));
    if (!cache->first) return GSF_ERROR_OUT_OF_MEMORY;
    cache->before = cache->first + sampled;
    cache->rest = cache->before + sampled;
    cache->size = rows * width;
    return GSF_OK;
}

static void gsf__dit_note_before(const gsf__dit_run* run, gsf_nn_block_cache* cache) {
    const int64_t rows = run->in->batch * run->tokens, d = run->width;
    float* to = cache->before;
    for (int64_t r = 0; r < rows; r += GSF__DIT_CACHE_ROWS, to += d) memcpy(to, run->x + r * d, (size_t)d * sizeof(float));
}

// 1 if the first block's residual is close to that of the previous call (relative L1); stores it for the next call.
static int gsf__dit_is_similar(const gsf__dit_run* run, gsf_nn_block_cache* cache) {
    const int64_t rows = run->in->batch * run->tokens, d = run->width;
    double change = 0.0, size = 0.0;
    const float* before = cache->before;
    float* first = cache->first;
    for (int64_t r = 0; r < rows; r += GSF__DIT_CACHE_ROWS, before += d, first += d)
        for (int64_t i = 0; i < d; i++) {
            const float added = run->x[r * d + i] - before[i];
            change += fabs((double)(added - first[i]));
            size += fabs((double)first[i]);
            first[i] = added;
        }
    return cache->calls > 0 && change < (double)cache->threshold * size;
}

static gsf_result gsf__dit_blocks(gsf__dit_run* run) {
    const gsf_nn_transformer* c = run->net;
    gsf_nn_block_cache* cache = run->in->cache && run->in->cache->threshold > 0.0f ? run->in->cache : NULL;
    const int64_t count = run->in->batch * run->tokens * run->width;
    if (cache) {
        GSF__TRY(gsf__dit_open_cache(run, cache));
        gsf__dit_note_before(run, cache);
    }
    for (int32_t i = 0; i < c->layers; i++) {
        GSF__TRY(gsf__dit_block_forward(run, i));
        GSF__TRY(gsf__nn_end_block(&run->nn, "transformer_blocks.", i, run->x, count));
        if (!cache || i > 0) continue;
        const int similar = gsf__dit_is_similar(run, cache);
        cache->calls++;
        if (similar) { // reuse what the other blocks added in the last full call
            cache->hits++;
            for (int64_t j = 0; j < count; j++) run->x[j] += cache->rest[j];
            return GSF_OK;
        }
        memcpy(cache->rest, run->x, (size_t)count * sizeof(float));
    }
    for (int64_t j = 0; cache && j < count; j++) cache->rest[j] = run->x[j] - cache->rest[j];
    return GSF_OK;
}

// ---- the whole pass

static gsf_result gsf__dit_check_size(gsf_context* ctx, const gsf_nn_transformer* c, int32_t height, int32_t width) {
    if (height < c->patch || width < c->patch || height % c->patch || width % c->patch)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "transformer: %d x %d latents are not multiples of the patch %d",
                        (int)width, (int)height, (int)c->patch);
    if (c->learned_positions && (height != c->sample_height || width != c->sample_width))
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED,
                        "transformer: latents of %d x %d; its learned positions are for %d x %d (diffusers refuses "
                        "other sizes as well)", (int)width, (int)height, (int)c->sample_width, (int)c->sample_height);
    return GSF_OK;
}

static gsf_result gsf__dit_check_input(gsf_context* ctx, const gsf_nn_transformer* c, const gsf_nn_transformer_desc* in) {
    if (!in->hidden || !in->text || !in->timesteps || in->batch < 1 || in->frames < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "transformer: latents, text or time steps are missing");
    GSF__TRY(gsf__dit_check_size(ctx, c, in->height, in->width));
    if (in->text_tokens < 0 || (c->learned_positions && in->text_tokens && in->text_tokens != c->text_tokens))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "transformer: %d text tokens, not %d", (int)in->text_tokens,
                        (int)c->text_tokens);
    if (in->references && (in->reference_tokens < 1 || (in->reference_batch != 1 && in->reference_batch != in->batch)))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "transformer: %lld reference tokens for %d of %d samples",
                        (long long)in->reference_tokens, (int)in->reference_batch, (int)in->batch);
    for (int32_t b = 0; b < in->batch; b++)
        if (!(in->timesteps[b] >= 0.0 && in->timesteps[b] < 1e6))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "transformer: time step %g", in->timesteps[b]);
    return GSF_OK;
}

static void gsf__dit_begin_run(gsf__dit_run* run, gsf_context* ctx, const gsf_nn_transformer* c) {
    memset(run, 0, sizeof *run);
    run->net = c;
    run->nets = (const gsf__dit_nets*)c->nets;
    run->width = gsf__dit_width(c);
    run->nn.ctx = ctx;
    run->nn.name = run->nn.stage = "transformer";
    run->nn.weights = &c->weights;
    run->nn.quantized = run->nets->quantized;
    run->nn.bf16 = c->bf16;
    run->nn.steps = c->layers;
}

static void gsf__dit_set_input(gsf__dit_run* run, const gsf_nn_transformer_desc* in) {
    const gsf_nn_transformer* c = run->net;
    run->in = in;
    run->nn.tap = in->_tap;
    run->text = in->text_tokens ? in->text_tokens : c->text_tokens;
    run->video = (int64_t)in->frames * (in->height / c->patch) * (in->width / c->patch);
    run->tokens = run->text + run->video;
    run->qkv_rows = in->references && in->reference_tokens > run->tokens ? in->reference_tokens : run->tokens;
    if (run->qkv_rows < 4) run->qkv_rows = 4; // a group of the feed-forward has 3/4 of them, which must not be 0
}

// Divides `memory` into buffers; NULL: only counts the floats needed.
static size_t gsf__dit_lay_out(gsf__dit_run* run, float* memory) {
    const gsf_nn_transformer* c = run->net;
    const size_t d = (size_t)run->width, rows = (size_t)run->tokens, time = (size_t)c->time_channels;
    const size_t channels = (size_t)(c->in_channels > c->out_channels ? c->in_channels : c->out_channels);
    const size_t patches = (size_t)run->video * (size_t)c->patch * (size_t)c->patch * channels;
    const int rotary = c->rotary_positions && !run->in->no_rotary;
    const size_t turns = rotary ? (size_t)run->video * (size_t)c->head_dim : 0;
    gsf__nn_arena arena = {memory, 0};
    run->nn.vectors_size = 2 * d;
    run->x = gsf__nn_share(&arena, (size_t)run->in->batch * rows * d);
    run->normed = gsf__nn_share(&arena, rows * d);
    run->qkv = gsf__nn_share(&arena, gsf__nn_larger(gsf__nn_larger(3 * (size_t)run->qkv_rows * d, patches), d + time));
    run->time = gsf__nn_share(&arena, (size_t)run->in->batch * time);
    run->modulation = gsf__nn_share(&arena, 6 * d);
    run->nn.vectors = gsf__nn_share(&arena, run->nn.vectors_size);
    run->cos = gsf__nn_share(&arena, turns);
    run->sin = gsf__nn_share(&arena, turns);
    if (!rotary) run->cos = run->sin = NULL;
    if (run->nn.tap) run->probe = gsf__nn_share(&arena, rows * d);
    return arena.used;
}

static gsf_result gsf__dit_make_rope(gsf__dit_run* run) {
    const gsf_nn_transformer* c = run->net;
    gsf__nn_rope_desc rope;
    if (!run->cos) return GSF_OK;
    memset(&rope, 0, sizeof rope);
    rope.frames = run->in->frames;
    rope.height = run->in->height / c->patch;
    rope.width = run->in->width / c->patch;
    rope.base_height = c->sample_height / c->patch;
    rope.base_width = c->sample_width / c->patch;
    rope.head_dim = c->head_dim;
    return gsf__nn_make_rope(run->nn.ctx, &rope, run->cos, run->sin);
}

static gsf_result gsf__dit_forward(gsf__dit_run* run, float* out) {
    const gsf_nn_transformer* c = run->net;
    const gsf_nn_transformer_desc* in = run->in;
    GSF__TRY(gsf__dit_make_rope(run));
    GSF__TRY(gsf__dit_embed_time(run));
    GSF__TRY(gsf__dit_embed(run));
    if (in->references)
        gsf__nn_reveal(&run->nn, in->references, 0, in->reference_batch, in->reference_tokens, run->width,
                       "cross_hidden_states");
    GSF__TRY(gsf__dit_blocks(run));
    const int64_t sample = (int64_t)in->frames * c->out_channels * in->height * in->width;
    for (int32_t b = 0; b < in->batch; b++) GSF__TRY(gsf__dit_head(run, b, out + b * sample));
    return gsf__nn_check(&run->nn, "the output layer", "proj_out.", out, in->batch * sample);
}

GSF_API gsf_result gsf_nn_run_transformer(gsf_context* ctx, const gsf_nn_transformer* transformer,
                                          const gsf_nn_transformer_desc* input, float* out) {
    gsf__dit_run run;
    GSF__TRY(gsf__dit_check_input(ctx, transformer, input));
    gsf__dit_begin_run(&run, ctx, transformer);
    gsf__dit_set_input(&run, input);
    float* memory = (float*)gsf_alloc(ctx, gsf__dit_lay_out(&run, NULL), sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__dit_lay_out(&run, memory);
    const gsf_result result = gsf__dit_forward(&run, out);
    gsf__nn_destroy_workspace(ctx, &run.nn.workspace);
    gsf_free(ctx, memory);
    return result;
}

// Number of floats in reference_kv: keys and values of all reference tokens for every block.
static size_t gsf__nn_query_reference_kv(const gsf_nn_transformer* transformer, int64_t reference_tokens,
                                         int32_t reference_batch) {
    return (size_t)transformer->layers * (size_t)reference_batch * 2 * (size_t)reference_tokens *
           (size_t)gsf__dit_width(transformer);
}

// Memory in bytes (in addition to mapped weights and about 70 MB of kernel scratch) and floating-point operations of
// one gsf_nn_run_transformer call.
static void gsf__nn_query_transformer(const gsf_nn_transformer* transformer, const gsf_nn_transformer_desc* input,
                                      double* bytes, double* flops) {
    const gsf_nn_transformer* c = transformer;
    gsf__dit_run run;
    gsf__dit_begin_run(&run, NULL, c);
    gsf__dit_set_input(&run, input);
    const double d = (double)run.width, n = (double)run.tokens, v = (double)run.video;
    const double r = input->references ? (double)input->reference_tokens : 0.0;
    const double self = 2.0 * n * d * d * 4.0 + 4.0 * n * n * d, ff = 2.0 * n * d * 4.0 * d * 2.0;
    const double cross = r > 0.0 ? 2.0 * v * d * d * 2.0 + 4.0 * v * r * d : 0.0, kv = 2.0 * r * d * d * 2.0;
    const double patch = (double)c->patch * c->patch;
    const double ends = 2.0 * v * patch * c->in_channels * d + 2.0 * v * patch * c->out_channels * d +
                        2.0 * (double)run.text * c->text_channels * d;
    const double kv_batch = input->reference_kv_ready ? 0.0 : (double)input->reference_batch;
    *bytes = (double)gsf__dit_lay_out(&run, NULL) * sizeof(float);
    *flops = c->layers * (input->batch * (self + ff + cross) + kv_batch * kv) + input->batch * ends;
}

GSF_API gsf_result gsf_nn_project_references(gsf_context* ctx, const gsf_nn_transformer* transformer, int64_t tokens,
                                             const float* dino, const float* vggt, float* out) {
    const int64_t d = gsf__dit_width(transformer);
    const gsf__dit_nets* nets = (const gsf__dit_nets*)transformer->nets;
    const struct { const gsf__dit_projector* by; const float* from; } parts[2] = {{&nets->dino, dino}, {&nets->vggt, vggt}};
    gsf__dit_run run;
    if (tokens < 1 || (!dino && !vggt))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "references: no tokens to project");
    gsf__dit_begin_run(&run, ctx, transformer);
    float* memory = (float*)gsf_alloc(ctx, (size_t)tokens + 2, (size_t)d * sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    run.nn.vectors = memory + tokens * d;
    run.nn.vectors_size = (size_t)(2 * d);
    gsf_result result = GSF_OK;
    for (int i = 0; i < 2 && !result; i++) {
        float* to = i && dino ? memory : out; // the second projection is added to the first
        if (!parts[i].from) continue;
        result = gsf__dit_linear(&run, &parts[i].by->linear, parts[i].from, tokens, to);
        if (!result) gsf__nn_norm(&run.nn, &parts[i].by->norm, 1e-5f, to, tokens, to); // PyTorch's default eps
        for (int64_t j = 0; !result && to == memory && j < tokens * d; j++) out[j] += memory[j];
    }
    gsf__nn_destroy_workspace(ctx, &run.nn.workspace);
    gsf_free(ctx, memory);
    return result;
}

// ---- >>nn scheduler -------------------------------------------------------------

// Zero terminal SNR: sqrt(abar) is shifted and scaled to end at 0 (Lin et al. 2024, algorithm 1). diffusers'
// DDIMScheduler, which the GSFixer release uses, does this in float32 and differs by up to 5e-7; its
// CogVideoXDDIMScheduler uses double.
static void gsf__nn_fill_table(const gsf_nn_schedule_desc* d, double* alpha_bar) {
    const int32_t n = d->train_steps;
    const double begin = d->linear_betas ? d->beta_start : sqrt(d->beta_start);
    const double end = d->linear_betas ? d->beta_end : sqrt(d->beta_end);
    double product = 1.0;
    for (int32_t i = 0; i < n; i++) {
        const double value = begin + (end - begin) / (n - 1) * i;
        product *= 1.0 - (d->linear_betas ? value : value * value);
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
    if ((int)d->spacing < 0 || d->spacing > GSF_NN_SPACING_LINSPACE || d->steps_offset < 0 ||
        d->steps_offset >= d->train_steps)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "schedule: spacing %d, steps_offset %d", (int)d->spacing,
                        (int)d->steps_offset);
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_make_schedule(gsf_context* ctx, const gsf_nn_schedule_desc* desc, gsf_nn_schedule* out) {
    memset(out, 0, sizeof *out);
    const gsf_nn_schedule_desc d = gsf__nn_schedule_defaults(desc);
    GSF__TRY(gsf__nn_check_schedule(ctx, &d));
    double* table = (double*)gsf_alloc(ctx, (size_t)d.train_steps, sizeof(double));
    if (!table) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__nn_fill_table(&d, table);
    int falls = table[0] < 1.0 && table[d.train_steps - 1] >= 0.0; // a NaN fails, too
    for (int32_t i = 1; falls && i < d.train_steps; i++) falls = table[i] <= table[i - 1];
    if (!falls) {
        gsf_free(ctx, table);
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE,
                        "schedule: betas from %g to %g over %d steps: alpha_bar does not fall to 0",
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

static gsf_result gsf__nn_read_schedule(const gsf__nn_config* config, gsf_nn_schedule_desc* d) {
    int rescale, alpha_one;
    const gsf__nn_key keys[] = {
        GSF__KEY_WORD_IS("prediction_type", "epsilon", "v_prediction"), GSF__KEY_FLAG_IS("clip_sample", 1, 0),
        GSF__KEY_FLAG_IS("thresholding", 0, 0), GSF__KEY_ABSENT("trained_betas"),
        GSF__KEY_INT_OR("num_train_timesteps", d->train_steps, 1000, 2, 1000000),
        GSF__KEY_REAL_OR("beta_start", d->beta_start, 0.0001, 1e-12, 0.999),
        GSF__KEY_WORD_OR("beta_schedule", d->linear_betas, "linear", "scaled_linear|linear"),
        GSF__KEY_FLAG_OR("rescale_betas_zero_snr", rescale, 0), GSF__KEY_FLAG_OR("set_alpha_to_one", alpha_one, 1),
        GSF__KEY_WORD_OR("timestep_spacing", d->spacing, "leading", "trailing|leading|linspace")};
    GSF__TRY(gsf__nn_config_read(config, keys, GSF__COUNT(keys)));
    const gsf__nn_key rest[] = { // with bounds that depend on the keys above
        GSF__KEY_INT_OR("steps_offset", d->steps_offset, 0, 0, (double)(d->train_steps - 1)),
        GSF__KEY_REAL_OR("beta_end", d->beta_end, 0.02, d->beta_start, 0.999)};
    d->no_zero_snr = !rescale;
    d->no_alpha_one = !alpha_one;
    return gsf__nn_config_read(config, rest, GSF__COUNT(rest));
}

GSF_API gsf_result gsf_nn_parse_schedule(gsf_context* ctx, const char* name, const char* text, size_t size,
                                         gsf_nn_schedule* out) {
    gsf__nn_config config;
    gsf_nn_schedule_desc d;
    memset(out, 0, sizeof *out);
    memset(&d, 0, sizeof d);
    GSF__TRY(gsf__nn_parse_config(ctx, name, text, size, &config));
    gsf_result result = gsf__nn_read_schedule(&config, &d);
    if (!result) result = gsf_nn_make_schedule(ctx, &d, out);
    gsf__nn_close_config(&config);
    return result;
}

GSF_API gsf_result gsf_nn_load_schedule(gsf_context* ctx, const char* path, gsf_nn_schedule* out) {
    void* text;
    size_t size;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf_read_file(ctx, path, &text, &size));
    const gsf_result result = gsf_nn_parse_schedule(ctx, path, (const char*)text, size, out);
    gsf_free(ctx, text);
    return result;
}

// Time step i of `steps`, before strength is applied; follows numpy, which rounds half to even.
static int32_t gsf__nn_timestep(const gsf_nn_schedule_desc* d, int32_t steps, int32_t i) {
    const double n = d->train_steps;
    switch (d->spacing) {
        case GSF_NN_SPACING_TRAILING: { // round(arange(n, 0, -n/steps)) - 1; arange multiplies its first difference
            const double difference = (n - n / steps) - n;
            return (int32_t)rint(n + i * difference) - 1;
        }
        case GSF_NN_SPACING_LEADING: return (steps - 1 - i) * (d->train_steps / steps) + d->steps_offset;
        case GSF_NN_SPACING_LINSPACE: { // round(linspace(0, n - 1, steps)) reversed
            if (steps == 1) return 0;
            return i == 0 ? d->train_steps - 1 : (int32_t)rint((steps - 1 - i) * ((n - 1.0) / (steps - 1)));
        }
    }
    return 0;
}

// Decreasing time steps for `steps` (1..train_steps) model calls. strength in (0, 1] (0: 1) keeps only the last
// (int)(steps * strength) of them, for sampling that starts from the noised render. out: room for `steps`.
static gsf_result gsf__nn_make_timesteps(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t steps,
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

// ---- elementwise updates

typedef struct gsf__nn_step { // m: predicted clean latents; m0, m1: of the last two steps; last: last corrected latents
    double m_x, m_v;                        // m = m_x x + m_v v
    double c_last, c_m, c_m0, c_m1;         // x = c_last last + c_m m + c_m0 m0 + c_m1 m1, if `correct`
    double p_x, p_m, p_m0;                  // next x = p_x x + p_m m + p_m0 m0
    int correct;
    size_t count;
    const float *x_in, *v;
    float *x, *x0, *m0, *m1, *last;         // all except x may be NULL
} gsf__nn_step;

static void gsf__nn_step_chunk(void* arg, size_t chunk, int32_t worker) {
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

// out = a x + b y
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

static void gsf__nn_add_noise(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x0,
                              const float* noise, size_t count, float* out) {
    const double bar = schedule->alpha_bar[timestep];
    gsf__nn_mix(ctx, sqrt(bar), x0, sqrt(1.0 - bar), noise, count, out);
}

GSF__SHARED void gsf__nn_make_velocity(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep,
                                       const float* x0, const float* noise, size_t count, float* out) {
    const double bar = schedule->alpha_bar[timestep];
    gsf__nn_mix(ctx, -sqrt(1.0 - bar), x0, sqrt(bar), noise, count, out);
}

// Elementwise over `count` values; out may be one of the inputs. timestep: 0..train_steps-1.
GSF__SHARED void gsf__nn_predict_x0(gsf_context* ctx, const gsf_nn_schedule* schedule, int32_t timestep, const float* x,
                                    const float* v, size_t count, float* out) {
    const double bar = schedule->alpha_bar[timestep];
    gsf__nn_mix(ctx, sqrt(bar), x, -sqrt(1.0 - bar), v, count, out);
}

// ---- solvers
/* With a = sqrt(abar), s = sqrt(1 - abar) and D(x) the predicted clean latents, the probability flow is
       d(x/s) = D du,  u = a/s = exp(lambda).
   DDIM assumes D is constant over a step; DPM-Solver++(2M) and UniPC assume it is linear in lambda (the UniPC
   corrector: quadratic). At zero SNR u is 0 and lambda -infinity: the first step from there is exact for constant
   D, and the one later step that would need lambda at that point takes D as linear in u instead. The last step ends at
   s = 0, where x equals D. */

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

// The point that the step from `index` leads to.
static gsf__nn_point gsf__nn_sampler_target(const gsf_nn_sampler* sampler, int32_t index) {
    const gsf_nn_schedule* schedule = sampler->schedule;
    const int32_t next = sampler->desc.solver == GSF_NN_SOLVER_DDIM
                             ? sampler->timesteps[index] - schedule->desc.train_steps / sampler->desc.steps
                             : index + 1 < sampler->count ? sampler->timesteps[index + 1] : -1;
    return gsf__nn_point_at(next >= 0 ? schedule->alpha_bar[next] : schedule->final_alpha_bar);
}

// lambda(q) - lambda(p); both must be finite.
static double gsf__nn_lambda(gsf__nn_point p, gsf__nn_point q) { return log(q.a * p.s / (q.s * p.a)); }

// Predictor from p to t; q: the point before p for second order, or NULL.
static void gsf__nn_predictor(gsf__nn_step* step, gsf__nn_point p, gsf__nn_point t, const gsf__nn_point* q) {
    step->p_x = t.s / p.s;
    step->p_m = t.a - p.a * step->p_x; // t.a (1 - exp(-h))
    step->p_m0 = 0.0;
    if (!q || t.s == 0.0 || p.a == 0.0) return;
    double weight; // coefficient of m - m0
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

// UniC-2 with B(h) = exp(-h) - 1 at the current point p. m0 was predicted at the previous point o, m1 at the point n
// before it; n is NULL in the second step, where the corrector is first order.
static void gsf__nn_corrector(gsf__nn_step* step, const gsf__nn_point* n, gsf__nn_point o, gsf__nn_point p) {
    const double rise = p.a - o.a * p.s / o.s; // p.a (1 - exp(-h))
    double weight = 0.5, earlier = 0.0;        // coefficients of m - m0 and of m1 - m0
    if (n) {
        const double h = gsf__nn_lambda(o, p), phi = expm1(-h);
        const double phi2 = phi / -h - 1.0, phi3 = phi2 / -h - 0.5; // h_phi_2, h_phi_3 in UniPC's code
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
    static const size_t kept[] = {0, 1, 3}; // buffers of value_count floats, by solver
    gsf_nn_sampler sampler;
    memset(out, 0, sizeof *out);
    memset(&sampler, 0, sizeof sampler);
    sampler.desc = *desc;
    sampler.schedule = schedule;
    if (!sampler.desc.steps) sampler.desc.steps = 50;
    if ((int)desc->solver < 0 || desc->solver > GSF_NN_SOLVER_UNIPC || sampler.desc.steps < 1 ||
        sampler.desc.steps > schedule->desc.train_steps || !gsf__mul_size(desc->value_count, 3, &sampler.memory_count))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sampler: solver %d, %d steps, %zu values", (int)desc->solver,
                        (int)sampler.desc.steps, desc->value_count);
    sampler.memory_count = kept[desc->solver] * desc->value_count;
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    sampler.timesteps = (int32_t*)gsf_alloc(ctx, (size_t)sampler.desc.steps, sizeof(int32_t));
    if (sampler.timesteps) sampler.memory = (float*)gsf_alloc_zeroed(ctx, sampler.memory_count, sizeof(float));
    if (sampler.memory)
        result = gsf__nn_make_timesteps(ctx, schedule, sampler.desc.steps, desc->strength, sampler.timesteps,
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

// a = 0 occurs only at zero SNR, which a schedule without zero SNR or a start below it (strength < 1) never reaches.
static void gsf__nn_plan_step(const gsf_nn_sampler* sampler, gsf__nn_step* step) {
    const int32_t i = sampler->index;
    const size_t n = sampler->desc.value_count;
    const gsf__nn_point p = gsf__nn_sampler_point(sampler, i), t = gsf__nn_sampler_target(sampler, i);
    gsf__nn_point before[2]; // points one and two steps earlier
    memset(before, 0, sizeof before);
    if (i > 0) before[0] = gsf__nn_sampler_point(sampler, i - 1);
    if (i > 1) before[1] = gsf__nn_sampler_point(sampler, i - 2);
    step->m_x = p.a;
    step->m_v = -p.s;
    const int second = sampler->desc.solver != GSF_NN_SOLVER_DDIM && i > 0 && i + 1 < sampler->count;
    gsf__nn_predictor(step, p, t, second ? &before[0] : NULL);
    if (sampler->desc.solver == GSF_NN_SOLVER_DDIM) return;
    step->m0 = sampler->memory;
    if (sampler->desc.solver != GSF_NN_SOLVER_UNIPC) return;
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
    const int64_t at = gsf__nn_find_not_finite(ctx, x, (int64_t)step.count);
    if (at >= 0)
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "step %d (time %d): latent %lld of %zu is NaN or infinite",
                        (int)sampler->index, (int)sampler->timesteps[sampler->index], (long long)at, step.count);
    sampler->index++;
    return GSF_OK;
}

// ---- >>nn sampling --------------------------------------------------------------

enum { GSF__SAMPLE_STREAM = 0x6e6f6973 }; // random stream of the initial noise

typedef struct gsf__sample_run {
    gsf_context* ctx;
    const gsf_nn_transformer* net;
    const gsf_nn_vae* vae;
    const gsf_nn_schedule* schedule;
    gsf_nn_sample_desc desc;       // with defaults filled in
    gsf_nn_sample_stats stats;
    int32_t frames, height, width; // of the latents
    int32_t channels;              // of the latents
    int64_t count;                 // number of latent values
    float *latents, *control;      // (frames, channels, height, width), control in the network's scale
    float *input, *prediction;     // (2, frames, 2 channels, height, width), (2, frames, channels, height, width)
    float* reference_kv;
    int32_t reference_kv_ready;
    gsf_nn_block_cache cache;
    gsf_nn_sampler sampler;
    uint32_t settings, clip; // checksums of everything the result depends on; only with a checkpoint
} gsf__sample_run;

GSF_API gsf_nn_sample_desc gsf_nn_resolve_sample_desc(const gsf_nn_sample_desc* desc) {
    gsf_nn_sample_desc d = *desc;
    if (!d.steps) d.steps = 50;
    if (d.guidance == 0.0f) d.guidance = 6.0f;
    if (d.guidance_end == 0.0f) d.guidance_end = 1.0f;
    if (d.strength == 0.0f) d.strength = 1.0f;
    return d;
}

static gsf_result gsf__sample_defaults(gsf_context* ctx, gsf_nn_sample_desc* d) {
    if (d->_start_canary != 0 || d->_end_canary != 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: the desc was not zeroed");
    *d = gsf_nn_resolve_sample_desc(d);
    if (d->steps < 1 || d->steps > 1000)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: %d steps, not 1 to 1000", (int)d->steps);
    if (!(d->strength > 0.0f && d->strength <= 1.0f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: strength %g is not in (0, 1]", (double)d->strength);
    if (!(d->guidance >= 1.0f && d->guidance < 1e4f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: guidance %g is below 1", (double)d->guidance);
    if (!(d->guidance_begin >= 0.0f && d->guidance_begin <= d->guidance_end && d->guidance_end <= 1.0f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: guidance from %g to %g of the steps",
                        (double)d->guidance_begin, (double)d->guidance_end);
    if (!(d->block_cache >= 0.0f && d->block_cache < 1e4f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: block cache threshold %g", (double)d->block_cache);
    return GSF_OK;
}

// Clip lengths that the VAE reproduces exactly: 1, 9, 17, ... for a temporal compression of 4.
static gsf_result gsf__sample_check_size(gsf_context* ctx, const gsf_nn_transformer* t, const gsf_nn_vae* v,
                                         const gsf_nn_sample_desc* d) {
    const int32_t step = 2 * v->temporal_ratio, square = v->spatial_ratio * t->patch;
    if (t->temporal_ratio != v->temporal_ratio || t->in_channels != 2 * v->latent_channels ||
        t->out_channels != v->latent_channels)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "sample: transformer (%d in, %d out) and VAE (%d latent) do not match",
                        (int)t->in_channels, (int)t->out_channels, (int)v->latent_channels);
    if (d->frames < 1 || (d->frames - 1) % step)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "sample: %d frames; must be 1, %d, %d, ...", (int)d->frames,
                        (int)(1 + step), (int)(1 + 2 * step));
    if (d->height < square || d->width < square || d->height % square || d->width % square)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "sample: frames of %d x %d are not multiples of %d", (int)d->width,
                        (int)d->height, (int)square);
    if (t->learned_positions && d->frames != t->sample_frames && !d->any_frames)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED,
                        "sample: %d frames; the model's positions are learned for %d (any_frames: use sines instead)",
                        (int)d->frames, (int)t->sample_frames);
    return gsf__dit_check_size(ctx, t, d->height / v->spatial_ratio, d->width / v->spatial_ratio);
}

static gsf_result gsf__sample_check(gsf_context* ctx, const gsf_nn_transformer* t, const gsf_nn_vae* v,
                                    gsf_nn_sample_desc* d) {
    GSF__TRY(gsf__sample_defaults(ctx, d));
    GSF__TRY(gsf__sample_check_size(ctx, t, v, d));
    if (!d->control || !d->text)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sample: control frames or text embeddings are missing");
    return GSF_OK;
}

// Transposes (channels, frames, plane) to (frames, channels, plane) or back, and multiplies by `factor`.
static void gsf__swap_frames(const float* from, int64_t outer, int64_t inner, int64_t plane, float factor, float* to) {
    for (int64_t i = 0; i < inner; i++)
        for (int64_t o = 0; o < outer; o++, to += plane) {
            const float* source = from + (o * inner + i) * plane;
            for (int64_t p = 0; p < plane; p++) to[p] = source[p] * factor;
        }
}

static gsf_result gsf__sample_encode(gsf__sample_run* run) {
    const gsf_nn_sample_desc* d = &run->desc;
    float* mean = run->prediction;
    GSF__TRY(gsf_nn_encode_vae(run->ctx, run->vae, NULL, d->control, d->frames, d->height, d->width, mean, NULL));
    gsf__swap_frames(mean, run->channels, run->frames, (int64_t)run->height * run->width,
                     (float)run->vae->scaling_factor, run->control);
    return GSF_OK;
}

static gsf_result gsf__sample_decode(gsf__sample_run* run, float* out) {
    gsf__swap_frames(run->latents, run->frames, run->channels, (int64_t)run->height * run->width,
                     (float)(1.0 / run->vae->scaling_factor), run->prediction);
    return gsf_nn_decode_vae(run->ctx, run->vae, NULL, run->prediction, run->frames, run->height, run->width, out);
}

// Pure noise, or for strength < 1 the control latents with the noise level of the first step.
static void gsf__sample_begin(gsf__sample_run* run) {
    const gsf_nn_sample_desc* d = &run->desc;
    for (int64_t i = 0; i < run->count; i++)
        run->latents[i] = d->noise ? d->noise[i] : (float)gsf_draw_normal(d->seed, GSF__SAMPLE_STREAM, (uint64_t)i);
    if (run->sampler.count < d->steps)
        gsf__nn_add_noise(run->ctx, run->schedule, run->sampler.timesteps[0], run->control, run->latents,
                          (size_t)run->count, run->latents);
}

// ---- checkpoint: identity of the job, step, latents and solver state

// Checksum that distinguishes weights without reading all of them: name, type and shape of every tensor, and 64 bytes
// each from its beginning, middle and end.
static uint32_t gsf__sample_sum_weights(uint32_t crc, const gsf_nn_weights* weights) {
    for (size_t i = 0; i < weights->tensor_count; i++) {
        const gsf_nn_tensor* t = &weights->tensors[i];
        const size_t size = (size_t)t->count * gsf_nn_get_dtype_size(t->dtype), part = size < 64 ? size : 64;
        const size_t at[3] = {0, (size - part) / 2, size - part};
        crc = gsf__crc32(crc, t->name, strlen(t->name) + 1);
        crc = gsf__crc32(crc, &t->dtype, sizeof t->dtype);
        crc = gsf__crc32(crc, t->shape, (size_t)t->rank * sizeof t->shape[0]);
        for (int k = 0; k < 3; k++) crc = gsf__crc32(crc, (const char*)t->data + at[k], part);
    }
    return crc;
}

// Checksum of everything that all clips of a run share: model, precision, schedule and settings.
static uint32_t gsf__sample_sum_settings(const gsf__sample_run* run) {
    const gsf_nn_sample_desc* d = &run->desc;
    const gsf_nn_transformer* t = run->net;
    const int int8 = ((const gsf__dit_nets*)t->nets)->quantized != NULL;
    const int32_t whole[] = {d->steps, (int32_t)d->solver, d->dynamic_guidance, t->layers, t->heads, t->bf16 != 0, int8,
                             run->schedule->desc.train_steps, (int32_t)run->schedule->desc.spacing,
                             run->schedule->desc.steps_offset};
    const float real[] = {d->guidance, d->guidance_begin, d->guidance_end, d->strength, d->block_cache};
    const size_t steps = (size_t)run->schedule->desc.train_steps;
    uint32_t crc = gsf__crc32(0, whole, sizeof whole);
    crc = gsf__crc32(crc, real, sizeof real);
    crc = gsf__crc32(crc, run->schedule->alpha_bar, steps * sizeof *run->schedule->alpha_bar);
    crc = gsf__crc32(crc, &run->schedule->final_alpha_bar, sizeof run->schedule->final_alpha_bar);
    crc = gsf__crc32(crc, run->sampler.timesteps, (size_t)run->sampler.count * sizeof *run->sampler.timesteps);
    crc = gsf__sample_sum_weights(crc, &t->weights);
    return gsf__sample_sum_weights(crc, &run->vae->weights);
}

// Checksum of the inputs of this clip.
static uint32_t gsf__sample_sum_clip(const gsf__sample_run* run) {
    const gsf_nn_sample_desc* d = &run->desc;
    const gsf_nn_transformer* t = run->net;
    const int32_t whole[] = {d->frames, d->height, d->width, d->noise != NULL, (int32_t)d->reference_tokens,
                             d->references != NULL};
    const size_t text = 2 * (size_t)t->text_tokens * (size_t)t->text_channels;
    uint32_t crc = gsf__crc32(0, whole, sizeof whole);
    crc = gsf__crc32(crc, &d->seed, sizeof d->seed);
    crc = gsf__crc32(crc, run->control, (size_t)run->count * sizeof(float));
    crc = gsf__crc32(crc, d->text, text * sizeof(float));
    if (d->noise) crc = gsf__crc32(crc, d->noise, (size_t)run->count * sizeof(float));
    if (d->references)
        crc = gsf__crc32(crc, d->references, (size_t)d->reference_tokens * (size_t)gsf__dit_width(t) * sizeof(float));
    return crc;
}

static gsf_result gsf__sample_save(gsf__sample_run* run) {
    if (!run->desc.checkpoint) return GSF_OK;
    gsf_buffer file;
    char head[12];
    memset(&file, 0, sizeof file);
    gsf__store_le(head, run->clip, 4);
    gsf__store_le(head + 4, (uint64_t)run->sampler.index, 4);
    gsf__store_le(head + 8, run->settings, 4);
    gsf_append_chunk(run->ctx, &file, "SAMP", head, sizeof head);
    gsf_append_chunk(run->ctx, &file, "LATE", run->latents, (size_t)run->count * sizeof(float));
    gsf_append_chunk(run->ctx, &file, "MEMO", run->sampler.memory, run->sampler.memory_count * sizeof(float));
    gsf_append_last_chunk(run->ctx, &file);
    const gsf_result result =
        file.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(run->ctx, run->desc.checkpoint, file.data, file.size);
    gsf_destroy_buffer(run->ctx, &file);
    return result;
}

static int gsf__sample_is_finite(const gsf_chunk* floats) {
    for (size_t i = 0; i + sizeof(float) <= floats->size; i += sizeof(float)) {
        float value;
        memcpy(&value, (const char*)floats->data + i, sizeof value);
        if (!(fabsf(value) <= FLT_MAX)) return 0;
    }
    return 1;
}

static void gsf__sample_take(gsf__sample_run* run, const void* data, size_t size) {
    gsf_chunk head, latents, memory;
    if (!gsf_find_chunk(data, size, "SAMP", &head) || !gsf_find_chunk(data, size, "LATE", &latents) ||
        !gsf_find_chunk(data, size, "MEMO", &memory))
        return;
    if (head.size != 12 || gsf__load_le((const char*)head.data + 8, 4) != run->settings) {
        gsf_log(run->ctx, GSF_LOG_WARNING, "%s: made with another model, precision or settings: the clip is restarted",
                run->desc.checkpoint);
        return;
    }
    if (latents.size != (size_t)run->count * sizeof(float) ||
        memory.size != run->sampler.memory_count * sizeof(float) || gsf__load_le(head.data, 4) != run->clip)
        return; // from another clip
    const int64_t index = (int64_t)gsf__load_le((const char*)head.data + 4, 4);
    if (index < 1 || index > run->sampler.count) return;
    // would fail the same way on every run
    if (!gsf__sample_is_finite(&latents) || !gsf__sample_is_finite(&memory)) return;
    memcpy(run->latents, latents.data, latents.size);
    if (memory.size) memcpy(run->sampler.memory, memory.data, memory.size);
    run->sampler.index = (int32_t)index;
}

// Resumes from the checkpoint if it belongs to this job. A checkpoint of another job, or a damaged one, is overwritten
// after the first step.
static gsf_result gsf__sample_resume(gsf__sample_run* run) {
    void* data;
    size_t size;
    if (!run->desc.checkpoint) return GSF_OK;
    GSF__TRY(gsf__nn_read_if_there(run->ctx, run->desc.checkpoint, &data, &size));
    if (!data) return GSF_OK;
    if (gsf_check_chunks(run->ctx, run->desc.checkpoint, data, size) == GSF_OK) gsf__sample_take(run, data, size);
    gsf_free(run->ctx, data);
    run->stats.resumed_from = run->sampler.index;
    return GSF_OK;
}

// ---- sampling steps

// Guidance of step `index`; 1: without the negative prompt.
static float gsf__sample_guidance(const gsf__sample_run* run, int32_t index) {
    const gsf_nn_sample_desc* d = &run->desc;
    const float at = ((float)index + 0.5f) / (float)run->sampler.count;
    if (at < d->guidance_begin || at > d->guidance_end) return 1.0f;
    if (!d->dynamic_guidance) return d->guidance;
    // As in diffusers' CogVideoXPipeline, which mixes units: t is a time step of up to 1000, n the number of steps.
    const double n = d->steps, t = run->sampler.timesteps[index];
    return (float)(1.0 + (double)d->guidance * (1.0 - cos(3.14159265358979323846 * pow((n - t) / n, 5.0))) / 2.0);
}

// Concatenates noisy latents and control along the channels, for each of `rows` samples.
static void gsf__sample_fill_input(gsf__sample_run* run, int32_t rows) {
    const size_t frame = (size_t)run->channels * (size_t)run->height * (size_t)run->width;
    float* to = run->input;
    for (int32_t b = 0; b < rows; b++)
        for (size_t f = 0; f < (size_t)run->frames; f++, to += 2 * frame) {
            memcpy(to, run->latents + f * frame, frame * sizeof(float));
            memcpy(to + frame, run->control + f * frame, frame * sizeof(float));
        }
}

static gsf_result gsf__sample_predict(gsf__sample_run* run, float guidance) {
    const gsf_nn_sample_desc* d = &run->desc;
    const gsf_nn_transformer* t = run->net;
    const int32_t rows = guidance == 1.0f ? 1 : 2;
    const double step = run->sampler.timesteps[run->sampler.index], steps[2] = {step, step};
    gsf_nn_transformer_desc in;
    memset(&in, 0, sizeof in);
    in.batch = rows;
    in.frames = run->frames;
    in.height = run->height;
    in.width = run->width;
    in.hidden = run->input;
    // order in d->text: negative prompt, prompt
    in.text = rows == 2 ? d->text : d->text + (int64_t)t->text_tokens * t->text_channels;
    in.timesteps = steps;
    in.references = d->references;
    in.reference_tokens = d->reference_tokens;
    in.reference_batch = 1;
    in.reference_kv = run->reference_kv;
    in.reference_kv_ready = run->reference_kv_ready;
    in.cache = &run->cache;
    const int64_t hits = run->cache.hits;
    gsf__sample_fill_input(run, rows);
    GSF__TRY(gsf_nn_run_transformer(run->ctx, t, &in, run->prediction));
    // If the cache skipped the blocks after the first one, their keys and values have not been computed yet.
    if (run->cache.hits == hits) run->reference_kv_ready = 1;
    run->stats.network_rows += rows;
    run->stats.cached_steps += run->cache.hits - hits;
    for (int64_t i = 0; rows == 2 && i < run->count; i++) {
        const float u = run->prediction[i], c = run->prediction[run->count + i];
        run->prediction[i] = u + guidance * (c - u);
    }
    return GSF_OK;
}

static gsf_result gsf__sample_steps(gsf__sample_run* run) {
    while (run->sampler.index < run->sampler.count) {
        const int32_t index = run->sampler.index;
        GSF__TRY(gsf__check_cancel(run->ctx));
        gsf__progress(run->ctx, "restore", index, run->sampler.count);
        GSF__TRY(gsf__sample_predict(run, gsf__sample_guidance(run, index)));
        GSF__TRY(gsf_nn_step_sampler(run->ctx, &run->sampler, run->prediction, run->latents, NULL));
        if (run->desc._tap) { // the latents after the step, and the (guided) prediction
            run->desc._tap->fn(run->desc._tap->user, "latents", index, run->latents, 1, run->count);
            run->desc._tap->fn(run->desc._tap->user, "prediction", index, run->prediction, 1, run->count);
        }
        run->stats.steps++;
        GSF__TRY(gsf__sample_save(run));
    }
    gsf__progress(run->ctx, "restore", run->sampler.count, run->sampler.count);
    return GSF_OK;
}

static gsf_result gsf__sample_run_all(gsf__sample_run* run, float* out) {
    gsf_nn_sampler_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.solver = run->desc.solver;
    desc.steps = run->desc.steps;
    desc.strength = (double)run->desc.strength;
    desc.value_count = (size_t)run->count;
    GSF__TRY(gsf_nn_make_sampler(run->ctx, run->schedule, &desc, &run->sampler));
    GSF__TRY(gsf__sample_encode(run));
    gsf__sample_begin(run);
    if (run->desc.checkpoint) {
        run->settings = gsf__sample_sum_settings(run);
        run->clip = gsf__sample_sum_clip(run);
    }
    GSF__TRY(gsf__sample_resume(run));
    run->cache.threshold = run->desc.block_cache;
    GSF__TRY(gsf__sample_steps(run));
    return gsf__sample_decode(run, out);
}

static void gsf__sample_sizes(gsf__sample_run* run, const gsf_nn_sample_desc* d) {
    run->frames = (d->frames - 1) / run->vae->temporal_ratio + 1;
    run->height = d->height / run->vae->spatial_ratio;
    run->width = d->width / run->vae->spatial_ratio;
    run->channels = run->vae->latent_channels;
    run->count = (int64_t)run->frames * run->channels * run->height * run->width;
}

static size_t gsf__sample_kv_size(const gsf__sample_run* run) {
    if (!run->desc.references || run->desc.no_reference_cache) return 0;
    return gsf__nn_query_reference_kv(run->net, run->desc.reference_tokens, 1);
}

enum { GSF__SAMPLE_BUFFERS = 8 }; // of run->count floats: latents 1, control 1, input 2 x 2, prediction 2

GSF_API gsf_result gsf_nn_query_sample(gsf_context* ctx, const gsf_nn_transformer* transformer, const gsf_nn_vae* vae,
                                       const gsf_nn_sample_desc* desc, gsf_nn_sample_info* out) {
    gsf__sample_run run;
    gsf_nn_vae_info encode, decode;
    memset(&run, 0, sizeof run);
    memset(out, 0, sizeof *out);
    run.net = transformer;
    run.vae = vae;
    run.desc = *desc;
    GSF__TRY(gsf__sample_defaults(ctx, &run.desc));
    GSF__TRY(gsf__sample_check_size(ctx, transformer, vae, &run.desc));
    gsf__sample_sizes(&run, &run.desc);
    GSF__TRY(gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_ENCODE, NULL, desc->frames, desc->height, desc->width, &encode));
    GSF__TRY(gsf_nn_query_vae(ctx, vae, GSF_NN_VAE_DECODE, NULL, run.frames, run.height, run.width, &decode));
    const int32_t steps = (int32_t)((double)run.desc.steps * (double)run.desc.strength);
    double bytes = 0.0;
    out->flops = encode.flops + decode.flops;
    for (int32_t i = 0; i < steps; i++) {
        const float at = ((float)i + 0.5f) / (float)steps;
        const int guided = run.desc.guidance != 1.0f && at >= run.desc.guidance_begin && at <= run.desc.guidance_end;
        gsf_nn_transformer_desc in;
        double step_bytes, step_flops;
        memset(&in, 0, sizeof in);
        in.batch = guided ? 2 : 1;
        in.frames = run.frames;
        in.height = run.height;
        in.width = run.width;
        in.references = desc->references;
        in.reference_tokens = desc->reference_tokens;
        in.reference_batch = 1;
        in.reference_kv_ready = i > 0 && !desc->no_reference_cache;
        gsf__nn_query_transformer(transformer, &in, &step_bytes, &step_flops);
        out->flops += step_flops;
        if (step_bytes > bytes) bytes = step_bytes;
    }
    if (run.desc.block_cache > 0.0f) bytes *= 1.3; // for the cached residuals, each as large as the stream
    if (encode.bytes > bytes) bytes = encode.bytes;
    if (decode.bytes > bytes) bytes = decode.bytes;
    const double own = (double)GSF__SAMPLE_BUFFERS * (double)run.count + (double)gsf__sample_kv_size(&run);
    out->bytes = bytes + own * sizeof(float);
    return GSF_OK;
}

static gsf_result gsf__sample_check_memory(gsf_context* ctx, const gsf_nn_transformer* t, const gsf_nn_vae* v,
                                           const gsf_nn_sample_desc* d) {
    gsf_nn_sample_info cost;
    if (!(d->max_bytes > 0.0)) return GSF_OK;
    GSF__TRY(gsf_nn_query_sample(ctx, t, v, d, &cost));
    if (cost.bytes <= d->max_bytes) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY,
                    "sample: %d frames of %d x %d need %.2f GB of memory, but only %.2f GB are allowed",
                    (int)d->frames, (int)d->width, (int)d->height, 1e-9 * cost.bytes, 1e-9 * d->max_bytes);
}

GSF_API gsf_result gsf_nn_sample(gsf_context* ctx, const gsf_nn_transformer* transformer, const gsf_nn_vae* vae,
                                 const gsf_nn_schedule* schedule, const gsf_nn_sample_desc* desc, float* out,
                                 gsf_nn_sample_stats* stats) {
    gsf__sample_run run;
    memset(&run, 0, sizeof run);
    run.ctx = ctx;
    run.net = transformer;
    run.vae = vae;
    run.schedule = schedule;
    run.desc = *desc;
    GSF__TRY(gsf__sample_check(ctx, transformer, vae, &run.desc));
    GSF__TRY(gsf__sample_check_memory(ctx, transformer, vae, &run.desc));
    gsf__sample_sizes(&run, &run.desc);
    const size_t count = (size_t)run.count, kv = gsf__sample_kv_size(&run);
    float* memory = (float*)gsf_alloc(ctx, GSF__SAMPLE_BUFFERS * count + kv, sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    run.latents = memory;
    run.control = memory + count;
    run.input = memory + 2 * count;
    run.prediction = memory + 6 * count;
    run.reference_kv = kv ? memory + GSF__SAMPLE_BUFFERS * count : NULL;
    const gsf_result result = gsf__sample_run_all(&run, out);
    if (stats) *stats = run.stats;
    gsf_nn_destroy_block_cache(ctx, &run.cache);
    gsf_nn_destroy_sampler(ctx, &run.sampler);
    gsf_free(ctx, memory);
    return result;
}

// ---- >>nn restorer --------------------------------------------------------------

typedef struct gsf__dit_kept { // features under the name they have in a features file
    char* name;
    float* values;
    int64_t shape[3];
    int encoded;               // 1: encoded by this restorer from the photos; 0: read from a file
} gsf__dit_kept;

typedef struct gsf__dit_restorer {
    gsf_nn_dit_desc desc;      // strings point into `texts`
    char* texts;
    gsf_nn_transformer transformer;
    gsf_nn_vae vae;
    gsf_nn_schedule schedule;
    gsf__dit_kept* kept;
    size_t kept_count, kept_capacity;
    int unsaved;               // `kept` has changed since the features were saved
    float *prompt, *references; // (2, text tokens, text channels); (reference_tokens, width) or NULL
    gsf_buffer caption;        // the caption that `prompt` was encoded from
    gsf_buffer shown;          // names the photos that `references` were encoded from
    int64_t reference_tokens;
    double encoder_bytes, encoder_flops; // at the configured size: largest peak; sum
    gsf_reference* photos;     // images (u8) and cameras, between begin and end
    int32_t photo_count;
    uint32_t photo_sum;        // checksum of their pixels
    double length;             // unit of camera distances, see gsf__dit_measure
} gsf__dit_restorer;

static gsf_result gsf__dit_query(void* user, gsf_context* ctx, int32_t frame_count, int32_t width, int32_t height,
                                 gsf_restorer_info* out) {
    const gsf__dit_restorer* r = (const gsf__dit_restorer*)user;
    const gsf_nn_transformer* t = &r->transformer;
    const gsf_nn_vae* v = &r->vae;
    const int32_t square = v->spatial_ratio * t->patch, step = 2 * v->temporal_ratio;
    out->squash = 1;
    out->width = t->sample_width * v->spatial_ratio;
    out->height = t->sample_height * v->spatial_ratio;
    out->frame_count = out->frame_count_min = out->frame_count_max = t->sample_frames;
    out->frame_count_step = step;
    if (r->desc.sample.any_frames) {
        out->frame_count_min = 1 + step;
        if (t->sample_frames < out->frame_count_min) out->frame_count_max = out->frame_count_min;
    }
    out->width_multiple = out->height_multiple = square;
    if (t->learned_positions) { // only this size
        out->width_multiple = out->width_max = out->width;
        out->height_multiple = out->height_max = out->height;
    }
    gsf_nn_sample_desc d = r->desc.sample;
    d.frames = frame_count;
    d.width = width;
    d.height = height;
    d.references = r->references;
    d.reference_tokens = r->reference_tokens;
    gsf_nn_sample_info cost;
    if (frame_count >= out->frame_count_min && frame_count <= out->frame_count_max && (frame_count - 1) % step == 0 &&
        width % out->width_multiple == 0 && height % out->height_multiple == 0 &&
        gsf_nn_query_sample(ctx, &r->transformer, &r->vae, &d, &cost) == GSF_OK) {
        out->bytes = cost.bytes > r->encoder_bytes ? cost.bytes : r->encoder_bytes;
        out->flops = cost.flops + r->encoder_flops;
    }
    return GSF_OK;
}

static void gsf__dit_end(void* user, gsf_context* ctx) {
    gsf__dit_restorer* r = (gsf__dit_restorer*)user;
    for (int32_t i = 0; i < r->photo_count; i++) gsf_destroy_image(ctx, &r->photos[i].color);
    gsf_free(ctx, r->photos);
    r->photos = NULL;
    r->photo_count = 0;
}

static int gsf__dit_compare(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return (x > y) - (x < y);
}

// Sets r->length to the median distance of the photos' cameras from the point they look at. The GSFixer release scales
// the scene so that this distance is 1 before it chooses references; a camera at that distance then counts as much as
// one turned by 180 degrees. The point is the mean of the points on the optical axes that are closest to the mean
// camera.
static gsf_result gsf__dit_measure(gsf_context* ctx, gsf__dit_restorer* r) {
    const int32_t n = r->photo_count;
    double mean[3] = {0.0, 0.0, 0.0}, focus[3] = {0.0, 0.0, 0.0}, center[3];
    double* distances = (double*)gsf_alloc(ctx, (size_t)n, sizeof *distances);
    if (!distances) return GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < n; i++) {
        gsf_get_camera_center(&r->photos[i].camera, center);
        for (int k = 0; k < 3; k++) mean[k] += center[k] / n;
    }
    for (int32_t i = 0; i < n; i++) {
        const double* m = r->photos[i].camera.w2c;
        double along = 0.0;
        gsf_get_camera_center(&r->photos[i].camera, center);
        for (int k = 0; k < 3; k++) along += m[4 * k + 2] * (mean[k] - center[k]); // third row of the rotation: forward
        for (int k = 0; k < 3; k++) focus[k] += (center[k] + along * m[4 * k + 2]) / n;
    }
    for (int32_t i = 0; i < n; i++) {
        double square = 0.0;
        gsf_get_camera_center(&r->photos[i].camera, center);
        for (int k = 0; k < 3; k++) square += (center[k] - focus[k]) * (center[k] - focus[k]);
        distances[i] = sqrt(square);
    }
    qsort(distances, (size_t)n, sizeof *distances, gsf__dit_compare);
    r->length = 0.5 * (distances[n / 2] + distances[(n - 1) / 2]);
    if (!(r->length > 0.0)) r->length = 1.0; // all cameras in one place: only directions count
    gsf_free(ctx, distances);
    return GSF_OK;
}

static void gsf__dit_forget_photos(gsf_context* ctx, gsf__dit_restorer* r);

static gsf_result gsf__dit_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t reference_count) {
    gsf__dit_restorer* r = (gsf__dit_restorer*)user;
    gsf_result result = GSF_OK;
    uint32_t sum = gsf__crc32(0, &reference_count, sizeof reference_count);
    if (r->photos) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dit: already in use by another run");
    if (reference_count > 0) {
        r->photos = (gsf_reference*)gsf_alloc_zeroed(ctx, (size_t)reference_count, sizeof *r->photos);
        if (!r->photos) return GSF_ERROR_OUT_OF_MEMORY;
        r->photo_count = reference_count;
        for (int32_t i = 0; i < reference_count; i++) r->photos[i].camera = references[i].camera;
        result = gsf__dit_measure(ctx, r);
    }
    for (int32_t i = 0; i < reference_count && !result; i++) {
        const gsf_image* color = &references[i].color;
        if (!color->data) continue;
        result = gsf_make_image(ctx, GSF_U8, color->width, color->height, 3, &r->photos[i].color);
        if (!result) result = gsf_convert_image(ctx, color, &r->photos[i].color);
        if (!result) sum = gsf__crc32(sum, &color->width, sizeof color->width);
        if (!result) sum = gsf__crc32(sum, r->photos[i].color.data, (size_t)(3 * color->width * color->height));
    }
    if (result) {
        gsf__dit_end(user, ctx);
        return result;
    }
    if (sum != r->photo_sum) gsf__dit_forget_photos(ctx, r);
    r->photo_sum = sum;
    return GSF_OK;
}

// The photo that was taken from the frame's view, or NULL.
static const gsf_reference* gsf__dit_photo(const gsf__dit_restorer* r, const gsf_restore_window* window, int32_t frame) {
    const int32_t photo = window->reference_index ? window->reference_index[frame] : -1;
    return photo >= 0 && photo < r->photo_count && r->photos[photo].color.data ? &r->photos[photo] : NULL;
}

typedef struct gsf__dit_control { // one frame of the control video
    const gsf_image* image;
    const gsf_image* photo;      // replaces the image where it covers the frame, or NULL
    double at[2], step[2];       // photo coordinates of the frame's first pixel; distance between pixels
    float* out;                  // (3, frames, height, width), offset to this frame
    int64_t plane;               // distance between channels
} gsf__dit_control;

static float gsf__dit_channel(const gsf_image* image, int64_t x, int64_t y, int64_t c) {
    float v;
    memcpy(&v, (const char*)image->data + y * image->stride_y + x * image->stride_x + c * image->stride_c, sizeof v);
    return v;
}

static int64_t gsf__dit_clamp(double v, int64_t count) { return v <= 0.0 ? 0 : gsf__least((int64_t)v, count - 1); }

// Bilinear lookup in the photo; returns 0 outside it.
static int gsf__dit_sample(const gsf__dit_control* control, int64_t x, int64_t y, float out[3]) {
    const gsf_image* p = control->photo;
    const double u = control->at[0] + control->step[0] * (double)x, v = control->at[1] + control->step[1] * (double)y;
    if (!(u >= -0.5 && v >= -0.5 && u <= (double)p->width - 0.5 && v <= (double)p->height - 0.5)) return 0;
    const int64_t x0 = gsf__dit_clamp(floor(u), p->width), x1 = gsf__dit_clamp(floor(u) + 1.0, p->width);
    const int64_t y0 = gsf__dit_clamp(floor(v), p->height), y1 = gsf__dit_clamp(floor(v) + 1.0, p->height);
    const float s = (float)(u - floor(u)), t = (float)(v - floor(v));
    for (int c = 0; c < 3; c++) {
        const float upper = gsf__dit_channel(p, x0, y0, c) * (1.0f - s) + gsf__dit_channel(p, x1, y0, c) * s;
        const float lower = gsf__dit_channel(p, x0, y1, c) * (1.0f - s) + gsf__dit_channel(p, x1, y1, c) * s;
        out[c] = upper * (1.0f - t) + lower * t;
    }
    return 1;
}

static void gsf__dit_control_row(void* arg, size_t row, int32_t worker) { // in [-1,1]; NaN becomes black
    const gsf__dit_control* control = (const gsf__dit_control*)arg;
    const gsf_image* image = control->image;
    const int64_t y = (int64_t)row;
    (void)worker;
    for (int64_t x = 0; x < image->width; x++) {
        float rgb[3];
        if (!control->photo || !gsf__dit_sample(control, x, y, rgb))
            for (int c = 0; c < 3; c++) rgb[c] = gsf__dit_channel(image, x, y, c);
        for (int c = 0; c < 3; c++)
            control->out[c * control->plane + y * image->width + x] =
                rgb[c] >= 1.0f ? 1.0f : rgb[c] > 0.0f ? 2.0f * rgb[c] - 1.0f : -1.0f;
    }
}

// Resizes the photo to the scale of the frame's camera, with the filter of the GSFixer release (PIL's bicubic),
// converts it to float and computes where the frame's pixels fall in it. Without cameras the photo fills the frame.
static gsf_result gsf__dit_fit_photo(gsf_context* ctx, const gsf_reference* photo, const gsf_camera* to, gsf_image* fitted,
                                     gsf__dit_control* control) {
    const gsf_camera* from = &photo->camera;
    const gsf_image* color = &photo->color;
    const double sides[2] = {(double)color->width, (double)color->height};
    const double frame[2] = {(double)control->image->width, (double)control->image->height};
    double step[2] = {sides[0] / frame[0], sides[1] / frame[1]}, first[2] = {0.5 * step[0], 0.5 * step[1]};
    if (to && from->fx > 0.0 && from->fy > 0.0 && to->fx > 0.0 && to->fy > 0.0) {
        step[0] = from->fx / to->fx;
        step[1] = from->fy / to->fy;
        first[0] = (0.5 - to->cx) * step[0] + from->cx;
        first[1] = (0.5 - to->cy) * step[1] + from->cy;
    }
    int64_t size[2];
    for (int k = 0; k < 2; k++) {
        const double wanted = rint(sides[k] / step[k]);
        if (!(wanted < 65536.0))
            return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "dit: a frame magnifies a photo %g times", 1.0 / step[k]);
        size[k] = wanted < 1.0 ? 1 : (int64_t)wanted;
        const double scale = (double)size[k] / sides[k];
        control->step[k] = step[k] * scale;
        control->at[k] = first[k] * scale - 0.5;
    }
    gsf_image bytes;
    memset(&bytes, 0, sizeof bytes);
    gsf_result result = gsf_make_image(ctx, GSF_U8, size[0], size[1], 3, &bytes);
    if (!result) result = gsf_resize_image(ctx, color, GSF_RESIZE_PIL_BICUBIC, &bytes);
    if (!result) result = gsf_make_image(ctx, GSF_F32, size[0], size[1], 3, fitted);
    if (!result) result = gsf_convert_image(ctx, &bytes, fitted);
    gsf_destroy_image(ctx, &bytes);
    control->photo = fitted;
    return result;
}

// Converts the frames to (3, frames, height, width). A frame at a reference's view is replaced by that photo, as in the
// paper's benchmark, seen through the frame's camera, which scales the axes independently and may crop.
static gsf_result gsf__dit_fill_control(gsf_context* ctx, const gsf__dit_restorer* r, const gsf_restore_window* window,
                                        float* out) {
    for (int32_t f = 0; f < window->frame_count; f++) {
        gsf__dit_control control;
        gsf_image fitted;
        const gsf_reference* photo = gsf__dit_photo(r, window, f);
        gsf_result result = GSF_OK;
        memset(&control, 0, sizeof control);
        memset(&fitted, 0, sizeof fitted);
        control.image = &window->color[f];
        const int64_t area = control.image->width * control.image->height;
        control.plane = window->frame_count * area;
        control.out = out + f * area;
        if (photo) result = gsf__dit_fit_photo(ctx, photo, window->cameras ? &window->cameras[f] : NULL, &fitted, &control);
        if (!result) gsf__parallel_for(ctx, (size_t)control.image->height, gsf__dit_control_row, &control);
        gsf_destroy_image(ctx, &fitted);
        GSF__TRY(result);
    }
    return GSF_OK;
}

static void gsf__dit_store_frames(const gsf_restore_window* window, const float* video) {
    const int64_t width = window->color[0].width, height = window->color[0].height, plane = width * height;
    for (int32_t f = 0; f < window->frame_count; f++) {
        const gsf_image *color = &window->out_color[f], *confidence = &window->out_confidence[f];
        for (int64_t y = 0; y < height; y++)
            for (int64_t x = 0; x < width; x++) {
                const float one = 1.0f;
                for (int64_t c = 0; c < 3; c++) {
                    const float v = video[(c * window->frame_count + f) * plane + y * width + x] * 0.5f + 0.5f;
                    const float clamped = v >= 1.0f ? 1.0f : v > 0.0f ? v : 0.0f;
                    memcpy((char*)color->data + y * color->stride_y + x * color->stride_x + c * color->stride_c, &clamped,
                           sizeof clamped);
                }
                memcpy((char*)confidence->data + y * confidence->stride_y + x * confidence->stride_x, &one, sizeof one);
            }
    }
}

// ---- restorer: encoding the conditions of a clip

// Prompt texts of the GSFixer release and of its training: appended to every caption; the negative prompt.
static const char gsf__dit_praise[] = ". The video is of high quality, and the view is very clear. High quality, "
                                      "masterpiece, best quality, highres, ultra-detailed, fantastic.";
static const char gsf__dit_negative[] = "The video is not of a high quality, it has a low resolution. Watermark present in "
                                        "each frame. The background is solid. Strange body and strange trajectory. "
                                        "Distortion. ";

enum { GSF__DIT_CAPTION_BYTES = 1024 };

// a call of an encoder; `photos` NULL: only load it, check that it fits and add up its cost
typedef struct gsf__dit_part {
    gsf_context* ctx;
    gsf__dit_restorer* r;
    const char* name;          // of its result in a features file
    const gsf_image* photos;
    int32_t count;
    gsf_nn_features* out;
} gsf__dit_part;

// Extends the error about a missing folder: what it is needed for and what can be given instead.
static gsf_result gsf__dit_absent(const gsf__dit_part* p, gsf_result result, const char* makes, const char* instead) {
    char before[sizeof p->ctx->error];
    if (result != GSF_ERROR_NOT_FOUND) return result;
    memcpy(before, p->ctx->error, sizeof before);
    return gsf_fail(p->ctx, result,
                    "%.250s (needed for %s; not needed with %.100s in the features file%s)", before, makes,
                    p->name, instead);
}

static gsf_result gsf__dit_misfit(const gsf__dit_part* p, const char* part, int64_t channels, int64_t expected) {
    if (channels == expected) return GSF_OK;
    return gsf_fail(p->ctx, GSF_ERROR_FORMAT, "%s/%s: outputs %lld channels, but the transformer expects %lld",
                    p->r->desc.model, part, (long long)channels, (long long)expected);
}

static void gsf__dit_add_cost(gsf__dit_restorer* r, double bytes, double flops) {
    if (bytes > r->encoder_bytes) r->encoder_bytes = bytes;
    r->encoder_flops += flops;
}

// Input size of two preprocessed photos with the aspect ratio of the transformer's frames, to estimate costs.
static gsf_nn_encoder_desc gsf__dit_usual_references(const gsf__dit_restorer* r) {
    const gsf_nn_transformer* t = &r->transformer;
    gsf_nn_encoder_desc in;
    memset(&in, 0, sizeof in);
    const double side = GSF__REFERENCE_SIDE, patch = GSF__REFERENCE_PATCH;
    const double patches = rint(side * t->sample_height / t->sample_width / patch);
    in.images = 2;
    in.width = GSF__REFERENCE_SIDE;
    in.height = GSF__REFERENCE_PATCH * (patches < 1.0 ? 1 : (int32_t)patches);
    return in;
}

typedef struct gsf__dit_kind { // a kind of reference tokens
    const char *name, *folder, *makes, *instead; // see gsf__dit_absent
} gsf__dit_kind;

enum { GSF__DIT_DINO, GSF__DIT_VGGT };
static const gsf__dit_kind gsf__dit_kinds[2] = {
    {"dino_latents", "dinov2", "the 2D reference tokens", ", or with condition 3d or none"},
    {"vggt_latents", "vggt", "the 3D reference tokens", ", or with condition 2d or none"}};

// Encodes p->photos with DINOv2 or VGGT.
static gsf_result gsf__dit_see(const gsf__dit_part* p, int kind) {
    const gsf__dit_kind* k = &gsf__dit_kinds[kind];
    const gsf_nn_transformer* t = &p->r->transformer;
    const gsf_nn_encoder_desc usual = gsf__dit_usual_references(p->r);
    const int vggt = kind == GSF__DIT_VGGT;
    gsf_nn_dinov2 flat;
    gsf_nn_vggt deep;
    gsf_buffer folder;
    double bytes, flops;
    gsf_result result = gsf__nn_join(p->ctx, p->r->desc.model, k->folder, &folder);
    if (!result) result = vggt ? gsf_nn_load_vggt(p->ctx, folder.data, &deep) : gsf_nn_load_dinov2(p->ctx, folder.data, &flat);
    gsf_destroy_buffer(p->ctx, &folder);
    if (result) return gsf__dit_absent(p, result, k->makes, k->instead);
    if (vggt) gsf__nn_query_vggt(&deep, &usual, &bytes, &flops);
    else gsf__nn_query_dinov2(&flat, &usual, &bytes, &flops);
    result = gsf__dit_misfit(p, k->folder, vggt ? 2 * (int64_t)deep.width : flat.width,
                             vggt ? t->vggt_channels : t->dino_channels);
    if (!p->photos) gsf__dit_add_cost(p->r, bytes, flops);
    else if (!result)
        result = gsf_nn_encode_references(p->ctx, vggt ? NULL : &flat, vggt ? &deep : NULL, p->photos, p->count, p->out);
    if (vggt) gsf_nn_destroy_vggt(p->ctx, &deep);
    else gsf_nn_destroy_dinov2(p->ctx, &flat);
    return result;
}

// Token ids of both prompts; caption NULL: only loads the tokenizer.
static gsf_result gsf__dit_tokenize(const gsf__dit_part* p, const char* caption, int32_t* ids) {
    gsf_buffer text;
    gsf_nn_tokenizer model;
    const size_t room = (size_t)p->r->transformer.text_tokens;
    gsf_result result = gsf__nn_join(p->ctx, p->r->desc.model, "tokenizer", &text);
    memset(&model, 0, sizeof model);
    if (!result) result = gsf_nn_load_tokenizer(p->ctx, text.data, &model);
    if (!result && caption) {
        text.size = 0;
        gsf_append_text(p->ctx, &text, "%s%s", caption, gsf__dit_praise);
        if (text.failed) result = GSF_ERROR_OUT_OF_MEMORY;
        if (!result)
            result = gsf_nn_encode_text(p->ctx, &model, gsf__dit_negative, sizeof gsf__dit_negative - 1, ids, room,
                                        NULL);
        if (!result) result = gsf_nn_encode_text(p->ctx, &model, text.data, text.size, ids + room, room, NULL);
    }
    gsf_nn_destroy_tokenizer(p->ctx, &model);
    gsf_destroy_buffer(p->ctx, &text);
    return result;
}

static gsf_result gsf__dit_encode_ids(const gsf__dit_part* p, const int32_t* ids) { // ids NULL: only loads the encoder
    gsf_buffer folder;
    gsf_nn_t5 model;
    gsf_nn_t5_desc in;
    double bytes, flops;
    memset(&in, 0, sizeof in);
    in.ids = ids;
    in.batch = 2;
    in.tokens = p->r->transformer.text_tokens;
    gsf_result result = gsf__nn_join(p->ctx, p->r->desc.model, "text_encoder", &folder);
    if (!result) result = gsf_nn_load_t5(p->ctx, folder.data, &model);
    gsf_destroy_buffer(p->ctx, &folder);
    if (result) return result;
    result = gsf__dit_misfit(p, "text_encoder", model.width, p->r->transformer.text_channels);
    gsf__nn_query_t5(&model, &in, &bytes, &flops);
    if (!ids) gsf__dit_add_cost(p->r, bytes, flops);
    else if (!result) result = gsf_nn_encode_t5(p->ctx, &model, &in, p->r->prompt);
    gsf_nn_destroy_t5(p->ctx, &model);
    return result;
}

static gsf_result gsf__dit_text(const gsf__dit_part* p, const char* caption) {
    gsf__dit_restorer* r = p->r;
    const size_t tokens = (size_t)r->transformer.text_tokens;
    int32_t* ids = NULL;
    if (caption) {
        if (r->prompt && r->caption.data && strcmp(r->caption.data, caption) == 0) return GSF_OK;
        if (!r->prompt)
            r->prompt = (float*)gsf_alloc(p->ctx, 2 * tokens * sizeof(float), (size_t)r->transformer.text_channels);
        ids = (int32_t*)gsf_alloc(p->ctx, 2 * tokens, sizeof *ids);
        gsf_destroy_buffer(p->ctx, &r->caption);
        if (!ids || !r->prompt) {
            gsf_free(p->ctx, ids);
            return GSF_ERROR_OUT_OF_MEMORY;
        }
    }
    gsf_result result = gsf__dit_tokenize(p, caption, ids);
    if (!result) result = gsf__dit_encode_ids(p, ids);
    gsf_free(p->ctx, ids);
    if (!result && caption) gsf_append_text(p->ctx, &r->caption, "%s", caption);
    return gsf__dit_absent(p, result, "the prompt embeddings", "");
}

// Captions the photo, out: GSF__DIT_CAPTION_BYTES; without a photo it only loads the captioner.
static gsf_result gsf__dit_describe(const gsf__dit_part* p, char* out) {
    gsf_buffer folder;
    gsf_nn_captioner model;
    double bytes, flops;
    gsf_result result = gsf__nn_join(p->ctx, p->r->desc.model, "blip2", &folder);
    if (!result) result = gsf_nn_load_captioner(p->ctx, folder.data, &model);
    gsf_destroy_buffer(p->ctx, &folder);
    if (result) return gsf__dit_absent(p, result, "the caption", ", or with a caption");
    gsf__nn_query_captioner(&model, 0, 0, &bytes, &flops);
    if (!p->photos) gsf__dit_add_cost(p->r, bytes, flops);
    else result = gsf_nn_caption_image(p->ctx, &model, p->photos, NULL, 0, out, GSF__DIT_CAPTION_BYTES);
    gsf_nn_destroy_captioner(p->ctx, &model);
    return result;
}

// The photo nearest to a camera, as GSFixer chooses references: by distance in units of r->length, which makes it
// independent of the scene's unit, plus half of 1 - cosine of the angle between the viewing directions. The first one
// wins a tie.
static int32_t gsf__dit_nearest(const gsf__dit_restorer* r, const gsf_camera* camera) {
    int32_t best = 0;
    double least = 0.0, center[3], other[3];
    gsf_get_camera_center(camera, center);
    for (int32_t i = 0; i < r->photo_count; i++) {
        const gsf_camera* c = &r->photos[i].camera;
        double square = 0.0, cosine = 0.0;
        gsf_get_camera_center(c, other);
        for (int k = 0; k < 3; k++) {
            square += (center[k] - other[k]) * (center[k] - other[k]);
            cosine += camera->w2c[4 * k + 2] * c->w2c[4 * k + 2]; // third row of the rotation: forward
        }
        const double score = sqrt(square) / r->length + 0.5 * (1.0 - cosine);
        if (i == 0 || score < least - 1e-9) {
            least = score;
            best = i;
        }
    }
    return best;
}

// Chooses the reference photos of a clip, at most max(photo_count, 2): those at the views of its first and last frame,
// or else those nearest to them. Without cameras all photos are used.
static int32_t gsf__dit_choose(const gsf__dit_restorer* r, const gsf_restore_window* window, int32_t* chosen) {
    const int32_t ends[2] = {0, window->frame_count - 1};
    if (r->photo_count < 1) return 0;
    for (int32_t i = 0; i < r->photo_count && !window->cameras; i++) chosen[i] = i;
    if (!window->cameras) return r->photo_count;
    for (int k = 0; k < 2; k++) {
        const gsf_reference* photo = gsf__dit_photo(r, window, ends[k]);
        chosen[k] = photo ? (int32_t)(photo - r->photos) : gsf__dit_nearest(r, &window->cameras[ends[k]]);
    }
    return 2;
}

// Encodes the chosen photos. They are first resized to the model's frame size regardless of aspect ratio, as in the
// GSFixer release, so that each one gives the same number of tokens.
static gsf_result gsf__dit_encode(const gsf__dit_part* part, int kind, const int32_t* chosen, int32_t count) {
    gsf__dit_restorer* r = part->r;
    gsf_context* ctx = part->ctx;
    gsf__dit_part p = *part;
    gsf_result result = GSF_OK;
    gsf_image* photos = (gsf_image*)gsf_alloc_zeroed(ctx, (size_t)count, sizeof *photos);
    if (!photos) return GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < count && !result; i++) {
        const gsf_image* color = &r->photos[chosen[i]].color;
        if (!color->data)
            result = gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dit: reference %d has no photo", (int)chosen[i]);
        if (!result)
            result = gsf_make_image(ctx, GSF_U8, r->transformer.sample_width * r->vae.spatial_ratio,
                                    r->transformer.sample_height * r->vae.spatial_ratio, 3, &photos[i]);
        if (!result) result = gsf_resize_image(ctx, color, GSF_RESIZE_PIL_BICUBIC, &photos[i]);
    }
    p.photos = photos;
    p.count = count;
    if (!result) result = gsf__dit_see(&p, kind);
    for (int32_t i = 0; i < count; i++) gsf_destroy_image(ctx, &photos[i]);
    gsf_free(ctx, photos);
    return result;
}

// ---- restorer: stored features, by name
/* Features of a whole run, in memory and in a safetensors file, each named by what it depends on:
       dino_latents.photo4       (1, tokens, channels): of photo 4, counted from 0 in the order of the references
       vggt_latents.photo4,7     (2, tokens, channels): of photos 4 and 7, which attend to each other
       prompt_embeds.clip12      (2, text tokens, text channels): negative prompt and prompt of clip 12, counted from 0
   A file for a single clip may use the bare names dino_latents, vggt_latents (images, tokens, channels) and
   prompt_embeds, which apply to clip 0 only. */

static const gsf__dit_kept* gsf__dit_find(const gsf__dit_restorer* r, const char* name) {
    for (size_t i = 0; i < r->kept_count; i++)
        if (strcmp(r->kept[i].name, name) == 0) return &r->kept[i];
    return NULL;
}

// Finds a feature by its own name or, for the first clip, by the bare name.
static const gsf__dit_kept* gsf__dit_find_own(const gsf__dit_restorer* r, const char* bare, const char* name, int32_t clip) {
    const gsf__dit_kept* own = gsf__dit_find(r, name);
    return own || clip ? own : gsf__dit_find(r, bare);
}

static void gsf__dit_drop(gsf_context* ctx, gsf__dit_restorer* r, size_t index) {
    gsf_free(ctx, r->kept[index].name);
    gsf_free(ctx, r->kept[index].values);
    r->kept[index] = r->kept[--r->kept_count];
}

// Drops features encoded by this restorer whose name starts with `begin`.
static void gsf__dit_drop_encoded(gsf_context* ctx, gsf__dit_restorer* r, const char* begin) {
    for (size_t i = r->kept_count; i-- > 0;)
        if (r->kept[i].encoded && strncmp(r->kept[i].name, begin, strlen(begin)) == 0) gsf__dit_drop(ctx, r, i);
}

static void gsf__dit_forget_photos(gsf_context* ctx, gsf__dit_restorer* r) {
    gsf__dit_drop_encoded(ctx, r, "");
    r->shown.size = 0;
}

// Adds a feature, replacing any of the same name; the caller fills in its values.
static gsf_result gsf__dit_keep(gsf_context* ctx, gsf__dit_restorer* r, const char* name, int64_t a, int64_t b, int64_t c,
                                int encoded, float** values) {
    for (size_t i = r->kept_count; i-- > 0;)
        if (strcmp(r->kept[i].name, name) == 0) gsf__dit_drop(ctx, r, i);
    GSF__TRY(gsf__reserve(ctx, (void**)&r->kept, &r->kept_capacity, r->kept_count, r->kept_count + 1, sizeof *r->kept));
    gsf__dit_kept* k = &r->kept[r->kept_count];
    k->name = (char*)gsf_alloc(ctx, strlen(name) + 1, 1);
    k->values = (float*)gsf_alloc(ctx, (size_t)(a * b), (size_t)c * sizeof(float));
    if (!k->name || !k->values) {
        gsf_free(ctx, k->name);
        gsf_free(ctx, k->values);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    memcpy(k->name, name, strlen(name) + 1);
    k->shape[0] = a;
    k->shape[1] = b;
    k->shape[2] = c;
    k->encoded = encoded;
    *values = k->values;
    r->kept_count++;
    r->unsaved = 1;
    return GSF_OK;
}

static int gsf__dit_compare_names(const void* a, const void* b) {
    return strcmp(((const gsf__dit_kept*)a)->name, ((const gsf__dit_kept*)b)->name);
}

static gsf_result gsf__dit_save(gsf_context* ctx, gsf__dit_restorer* r) {
    if (!r->desc.save_features || !r->unsaved) return GSF_OK;
    // deterministic order in the file
    if (r->kept_count) qsort(r->kept, r->kept_count, sizeof *r->kept, gsf__dit_compare_names);
    gsf_nn_tensor* tensors = (gsf_nn_tensor*)gsf_alloc(ctx, r->kept_count + 1, sizeof *tensors);
    if (!tensors) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < r->kept_count; i++)
        tensors[i] = gsf_nn_wrap_tensor(r->kept[i].name, r->kept[i].values, 3, r->kept[i].shape);
    const gsf_result result = gsf_nn_save_tensors(ctx, r->desc.save_features, tensors, r->kept_count);
    gsf_free(ctx, tensors);
    if (!result) r->unsaved = 0;
    return result;
}

// Composes a name such as "dino_latents.photo4,7".
static gsf_result gsf__dit_name_photos(gsf_context* ctx, const char* bare, const int32_t* photos, int32_t count,
                                       gsf_buffer* out) {
    out->size = 0;
    gsf_append_text(ctx, out, "%s.photo", bare);
    for (int32_t i = 0; i < count; i++) gsf_append_text(ctx, out, i ? ",%d" : "%d", (int)photos[i]);
    return out->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

// ---- restorer: conditions of a clip, stored or encoded on demand

typedef struct gsf__dit_clip { // the clip whose features are collected
    gsf_context* ctx;
    gsf__dit_restorer* r;
    int32_t clip;
    int32_t* chosen;           // photo indices
    int32_t count;
    gsf_buffer name;           // scratch
    gsf_nn_features features;
} gsf__dit_clip;

static gsf_result gsf__dit_need_photos(const gsf__dit_clip* c) {
    if (c->count > 0) return GSF_OK;
    return gsf_fail(c->ctx, GSF_ERROR_INVALID_ARGUMENT, "dit: no reference photos (only condition none needs none)");
}

// Appends the rows of `kept` to those of earlier photos.
static gsf_result gsf__dit_append(gsf__dit_clip* c, const gsf__dit_kept* kept, int64_t images, float** values) {
    const size_t each = (size_t)(kept->shape[0] * kept->shape[1] * kept->shape[2]);
    if (!*values) {
        *values = (float*)gsf_alloc(c->ctx, (size_t)(images * kept->shape[1]), (size_t)kept->shape[2] * sizeof(float));
        if (!*values) return GSF_ERROR_OUT_OF_MEMORY;
        if (!c->features.tokens) c->features.tokens = kept->shape[1];
    }
    if (kept->shape[1] != c->features.tokens)
        return gsf_fail(c->ctx, GSF_ERROR_FORMAT, "dit: %lld tokens of an image in %s, but %lld in other features",
                        (long long)kept->shape[1], kept->name, (long long)c->features.tokens);
    memcpy(*values + (size_t)c->features.images * each, kept->values, each * sizeof(float));
    c->features.images += kept->shape[0];
    return GSF_OK;
}

/* DINOv2 encodes photos independently, so each photo has its own name and is encoded once per run. VGGT encodes the
   photos of a clip together, under a common name. Both are handled as groups of `per` photos. */

// Sets c->name to the name of the group that starts at photos[first].
static gsf_result gsf__dit_name_group(gsf__dit_clip* c, int kind, const int32_t* photos, int32_t first, int32_t per) {
    return gsf__dit_name_photos(c->ctx, gsf__dit_kinds[kind].name, photos + first, per, &c->name);
}

// Encodes those of the clip's photos that are not stored yet, in one call, and stores them group by group.
static gsf_result gsf__dit_encode_missing(gsf__dit_clip* c, int kind, int32_t per) {
    gsf_nn_features made;
    gsf_result result = GSF_OK;
    int32_t missing = 0;
    memset(&made, 0, sizeof made);
    int32_t* list = (int32_t*)gsf_alloc(c->ctx, (size_t)c->count, sizeof *list);
    if (!list) return GSF_ERROR_OUT_OF_MEMORY;
    // limits memory, as there may be many pairs
    if (per > 1 && !c->r->desc.save_features) gsf__dit_drop_encoded(c->ctx, c->r, "vggt_latents.");
    for (int32_t i = 0; i < c->count && !result; i += per) {
        int known = 0;
        for (int32_t k = 0; k < missing && per == 1; k++) known |= list[k] == c->chosen[i];
        result = gsf__dit_name_group(c, kind, c->chosen, i, per);
        if (result || known || gsf__dit_find(c->r, c->name.data)) continue;
        memcpy(list + missing, c->chosen + i, (size_t)per * sizeof *list);
        missing += per;
    }
    if (!result && missing) {
        result = gsf__dit_name_group(c, kind, list, 0, per);
        const gsf__dit_part part = {c->ctx, c->r, c->name.data, NULL, 0, &made};
        if (!result) result = gsf__dit_encode(&part, kind, list, missing);
    }
    const int64_t channels = kind == GSF__DIT_VGGT ? made.vggt_channels : made.dino_channels;
    const float* from = kind == GSF__DIT_VGGT ? made.vggt : made.dino;
    for (int32_t i = 0; i < missing && !result; i += per) {
        float* values;
        const size_t each = (size_t)(per * made.tokens * channels);
        result = gsf__dit_name_group(c, kind, list, i, per);
        if (!result) result = gsf__dit_keep(c->ctx, c->r, c->name.data, per, made.tokens, channels, 1, &values);
        if (!result) memcpy(values, from + (size_t)(i / per) * each, each * sizeof(float));
    }
    gsf_nn_destroy_features(c->ctx, &made);
    gsf_free(c->ctx, list);
    return result;
}

// Collects the clip's features of one kind, stored or encoded now.
static gsf_result gsf__dit_gather(gsf__dit_clip* c, int kind, float** values, int64_t* channels) {
    const int32_t per = kind == GSF__DIT_VGGT && c->count > 0 ? c->count : 1;
    const gsf__dit_kept* bare = c->clip ? NULL : gsf__dit_find(c->r, gsf__dit_kinds[kind].name);
    int own = c->count > 0;
    for (int32_t i = 0; i < c->count; i += per) {
        GSF__TRY(gsf__dit_name_group(c, kind, c->chosen, i, per));
        own &= gsf__dit_find(c->r, c->name.data) != NULL;
    }
    const int64_t before = c->features.images;
    c->features.images = 0;
    *channels = kind == GSF__DIT_VGGT ? c->r->transformer.vggt_channels : c->r->transformer.dino_channels;
    if (!own && bare) {
        GSF__TRY(gsf__dit_append(c, bare, bare->shape[0], values));
    } else {
        GSF__TRY(gsf__dit_need_photos(c));
        if (!own) GSF__TRY(gsf__dit_encode_missing(c, kind, per));
        for (int32_t i = 0; i < c->count; i += per) {
            GSF__TRY(gsf__dit_name_group(c, kind, c->chosen, i, per));
            GSF__TRY(gsf__dit_append(c, gsf__dit_find(c->r, c->name.data), c->count, values));
        }
    }
    if (before == 0 || before == c->features.images) return GSF_OK;
    return gsf_fail(c->ctx, GSF_ERROR_FORMAT, "dit: 2D features of %lld images, but 3D features of %lld", (long long)before,
                    (long long)c->features.images);
}

// Projects the clip's features to reference tokens.
static gsf_result gsf__dit_project(gsf_context* ctx, gsf__dit_restorer* r, const gsf_nn_features* f) {
    r->reference_tokens = f->images * f->tokens;
    gsf_free(ctx, r->references);
    r->references = (float*)gsf_alloc(ctx, (size_t)r->reference_tokens,
                                      (size_t)gsf__dit_width(&r->transformer) * sizeof(float));
    if (!r->references) return GSF_ERROR_OUT_OF_MEMORY;
    return gsf_nn_project_references(ctx, &r->transformer, r->reference_tokens, f->dino, f->vggt, r->references);
}

static int32_t gsf__dit_clip_number(const gsf_restore_window* window) { // 0 if the host's struct lacks this member
    return window->struct_size >= GSF__WINDOW_BYTES ? window->clip : 0;
}

static gsf_result gsf__dit_refer(gsf_context* ctx, gsf__dit_restorer* r, const gsf_restore_window* window) {
    gsf__dit_clip c;
    gsf_buffer shown;
    if (r->desc.condition == GSF_NN_CONDITION_NONE) return GSF_OK;
    memset(&c, 0, sizeof c);
    memset(&shown, 0, sizeof shown);
    c.ctx = ctx;
    c.r = r;
    c.clip = gsf__dit_clip_number(window);
    c.chosen = (int32_t*)gsf_alloc(ctx, (size_t)r->photo_count + 2, sizeof *c.chosen);
    if (!c.chosen) return GSF_ERROR_OUT_OF_MEMORY;
    c.count = gsf__dit_choose(r, window, c.chosen);
    gsf_result result = gsf__dit_name_photos(ctx, c.clip ? "references" : "first", c.chosen, c.count, &shown);
    if (!result && (!r->shown.size || strcmp(r->shown.data, shown.data) != 0)) {
        r->shown.size = 0;
        gsf_nn_features* f = &c.features;
        if (r->desc.condition != GSF_NN_CONDITION_3D) result = gsf__dit_gather(&c, GSF__DIT_DINO, &f->dino,
                                                                               &f->dino_channels);
        if (!result && r->desc.condition != GSF_NN_CONDITION_2D)
            result = gsf__dit_gather(&c, GSF__DIT_VGGT, &f->vggt, &f->vggt_channels);
        if (!result) result = gsf__dit_project(ctx, r, &c.features);
        if (!result) gsf_append_text(ctx, &r->shown, "%s", shown.data);
        if (r->shown.failed) result = GSF_ERROR_OUT_OF_MEMORY;
    }
    gsf_nn_destroy_features(ctx, &c.features);
    gsf_destroy_buffer(ctx, &c.name);
    gsf_destroy_buffer(ctx, &shown);
    gsf_free(ctx, c.chosen);
    return result;
}

// Embeddings of the clip's negative prompt and prompt, stored or encoded now.
static gsf_result gsf__dit_prompt(gsf_context* ctx, gsf__dit_restorer* r, const gsf_restore_window* window,
                                  const float** text) {
    char described[GSF__DIT_CAPTION_BYTES], name[40];
    const gsf_nn_transformer* t = &r->transformer;
    const char* caption = r->desc.caption ? r->desc.caption : window->caption;
    const gsf_reference* photo = gsf__dit_photo(r, window, 0);
    const int32_t clip = gsf__dit_clip_number(window);
    snprintf(name, sizeof name, "prompt_embeds.clip%d", (int)clip);
    const gsf__dit_part part = {ctx, r, name, photo ? &photo->color : &window->color[0], 1, NULL};
    const gsf__dit_kept* kept = gsf__dit_find_own(r, "prompt_embeds", name, clip);
    if (kept && !kept->encoded) { // an encoded one may be from an earlier clip with the same number
        *text = kept->values;
        return GSF_OK;
    }
    if (!caption) {
        GSF__TRY(gsf__dit_describe(&part, described));
        caption = described;
    }
    GSF__TRY(gsf__dit_text(&part, caption));
    *text = r->prompt;
    if (!r->desc.save_features) return GSF_OK;
    float* values;
    GSF__TRY(gsf__dit_keep(ctx, r, name, 2, t->text_tokens, t->text_channels, 1, &values));
    memcpy(values, r->prompt, 2 * (size_t)t->text_tokens * (size_t)t->text_channels * sizeof(float));
    return GSF_OK;
}

// Each part of a clip has a checkpoint of its own, so that finished parts are not sampled again.
static gsf_result gsf__dit_checkpoint(gsf_context* ctx, const gsf__dit_restorer* r, const gsf_restore_window* window,
                                      gsf_buffer* path, gsf_nn_sample_desc* d) {
    if (!d->checkpoint || window->struct_size < GSF__WINDOW_BYTES || !window->part) return GSF_OK;
    gsf_append_text(ctx, path, "%s.%d", r->desc.sample.checkpoint, (int)window->part);
    d->checkpoint = path->data;
    return path->failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
}

static gsf_result gsf__dit_restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    gsf__dit_restorer* r = (gsf__dit_restorer*)user;
    gsf_nn_sample_desc d = r->desc.sample;
    gsf_buffer checkpoint;
    memset(&checkpoint, 0, sizeof checkpoint);
    gsf__progress(ctx, "clip", 0.0, 1.0);
    GSF__TRY(gsf__dit_prompt(ctx, r, window, &d.text));
    GSF__TRY(gsf__dit_refer(ctx, r, window));
    GSF__TRY(gsf__dit_save(ctx, r));
    d.frames = window->frame_count;
    d.width = (int32_t)window->color[0].width;
    d.height = (int32_t)window->color[0].height;
    d.references = r->references;
    d.reference_tokens = r->reference_tokens;
    d.seed = window->seed;
    const size_t values = (size_t)3 * (size_t)d.frames * (size_t)d.width * (size_t)d.height;
    float* video = (float*)gsf_alloc(ctx, values, 2 * sizeof(float));
    if (!video) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = gsf__dit_fill_control(ctx, r, window, video);
    if (!result) result = gsf__dit_checkpoint(ctx, r, window, &checkpoint, &d);
    d.control = video;
    if (!result) result = gsf_nn_sample(ctx, &r->transformer, &r->vae, &r->schedule, &d, video + values, NULL);
    if (!result) gsf__dit_store_frames(window, video + values);
    gsf_destroy_buffer(ctx, &checkpoint);
    gsf_free(ctx, video);
    return result;
}

// ---- restorer: loading

// 1 if `name` is the bare name, or the bare name followed by "." and `of`.
static int gsf__dit_is_name(const char* name, const char* bare, const char* of) {
    const size_t length = strlen(bare);
    if (strncmp(name, bare, length) != 0) return 0;
    return !name[length] || (name[length] == '.' && strncmp(name + length + 1, of, strlen(of)) == 0);
}

// 1 if any stored feature has such a name.
static int gsf__dit_has(const gsf__dit_restorer* r, const char* bare, const char* of) {
    for (size_t i = 0; i < r->kept_count; i++)
        if (gsf__dit_is_name(r->kept[i].name, bare, of)) return 1;
    return 0;
}

static gsf_result gsf__dit_read_feature(gsf_context* ctx, gsf__dit_restorer* r, const char* file,
                                        const gsf_nn_tensor* t) {
    const gsf_nn_transformer* c = &r->transformer;
    const int prompt = gsf__dit_is_name(t->name, "prompt_embeds", "clip");
    const int dino = gsf__dit_is_name(t->name, "dino_latents", "photo");
    const int64_t channels = prompt ? c->text_channels : dino ? c->dino_channels : c->vggt_channels;
    float* values;
    if (!prompt && !dino && !gsf__dit_is_name(t->name, "vggt_latents", "photo")) return GSF_OK;
    if (t->rank != 3 || t->count < 1 || t->shape[2] != channels ||
        (prompt && (t->shape[0] != 2 || t->shape[1] != c->text_tokens)))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: tensor %s does not consist of rows of %lld values", file, t->name,
                        (long long)channels);
    GSF__TRY(gsf__dit_keep(ctx, r, t->name, t->shape[0], t->shape[1], t->shape[2], 0, &values));
    gsf_nn_convert_tensor(t, 0, t->count, values);
    return GSF_OK;
}

// data: the file's bytes if they have been read already, or NULL.
static gsf_result gsf__dit_read_features(gsf_context* ctx, gsf__dit_restorer* r, const char* path, const void* data,
                                         size_t size) {
    gsf_nn_weights file;
    gsf_result result = data ? gsf_nn_parse_weights(ctx, path, data, size, &file)
                             : gsf_nn_load_weights(ctx, path, NULL, &file);
    for (size_t i = 0; i < file.tensor_count && !result; i++)
        result = gsf__dit_read_feature(ctx, r, file.name, &file.tensors[i]);
    const gsf__dit_kept *dino = gsf__dit_find(r, "dino_latents"), *vggt = gsf__dit_find(r, "vggt_latents");
    if (!result && dino && vggt && (dino->shape[0] != vggt->shape[0] || dino->shape[1] != vggt->shape[1]))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: %lld x %lld rows of dino_latents, but %lld x %lld of vggt_latents",
                          file.name, (long long)dino->shape[0], (long long)dino->shape[1], (long long)vggt->shape[0],
                          (long long)vggt->shape[1]);
    gsf_nn_destroy_weights(ctx, &file);
    return result;
}

// Reads the features files, and loads every model once that is needed for features missing from the first one, to
// report missing folders early and to add up costs.
static gsf_result gsf__dit_open_conditions(gsf_context* ctx, gsf__dit_restorer* r) {
    const gsf_nn_condition condition = r->desc.condition;
    const gsf__dit_part prompt = {ctx, r, "prompt_embeds", NULL, 0, NULL}, dino = {ctx, r, "dino_latents", NULL, 0, NULL};
    const gsf__dit_part vggt = {ctx, r, "vggt_latents", NULL, 0, NULL};
    void* saved = NULL;
    size_t size;
    if (r->desc.features) GSF__TRY(gsf__dit_read_features(ctx, r, r->desc.features, NULL, 0));
    r->unsaved = 1;
    if (!gsf__dit_has(r, "prompt_embeds", "clip")) {
        GSF__TRY(gsf__dit_text(&prompt, NULL));
        if (!r->desc.caption) GSF__TRY(gsf__dit_describe(&prompt, NULL));
    }
    if (condition != GSF_NN_CONDITION_NONE && condition != GSF_NN_CONDITION_3D && !gsf__dit_has(r, "dino_latents",
                                                                                                "photo"))
        GSF__TRY(gsf__dit_see(&dino, GSF__DIT_DINO));
    if (condition != GSF_NN_CONDITION_NONE && condition != GSF_NN_CONDITION_2D && !gsf__dit_has(r, "vggt_latents",
                                                                                                "photo"))
        GSF__TRY(gsf__dit_see(&vggt, GSF__DIT_VGGT));
    // read last, so that a resumed run checks the same folders as before
    if (r->desc.keep_saved && r->desc.save_features)
        GSF__TRY(gsf__nn_read_if_there(ctx, r->desc.save_features, &saved, &size));
    const gsf_result result = saved ? gsf__dit_read_features(ctx, r, r->desc.save_features, saved, size) : GSF_OK;
    gsf_free(ctx, saved);
    return result;
}

static gsf_result gsf__dit_open(gsf_context* ctx, gsf__dit_restorer* r) {
    static const char* const parts[3] = {"transformer", "vae", "scheduler/scheduler_config.json"};
    gsf_result result = GSF_OK;
    for (int i = 0; i < 3 && !result; i++) {
        gsf_buffer path;
        result = gsf__nn_join(ctx, r->desc.model, parts[i], &path);
        if (!result)
            result = i == 0   ? gsf_nn_load_transformer(ctx, path.data, &r->transformer)
                     : i == 1 ? gsf_nn_load_vae(ctx, path.data, &r->vae)
                              : gsf_nn_load_schedule(ctx, path.data, &r->schedule);
        gsf_destroy_buffer(ctx, &path);
    }
    if (!result) result = gsf__dit_open_conditions(ctx, r);
    r->transformer.bf16 = r->desc.bf16;
    return !result && r->desc.int8 ? gsf_nn_quantize_transformer(ctx, &r->transformer, NULL) : result;
}

GSF_API void gsf_nn_destroy_dit(gsf_context* ctx, gsf_restorer* restorer) {
    gsf__dit_restorer* r = (gsf__dit_restorer*)restorer->user;
    memset(restorer, 0, sizeof *restorer);
    if (!r) return;
    gsf__dit_end(r, ctx);
    gsf_nn_destroy_transformer(ctx, &r->transformer);
    gsf_nn_destroy_vae(ctx, &r->vae);
    gsf_nn_destroy_schedule(ctx, &r->schedule);
    while (r->kept_count) gsf__dit_drop(ctx, r, r->kept_count - 1);
    gsf_free(ctx, r->kept);
    gsf_destroy_buffer(ctx, &r->caption);
    gsf_destroy_buffer(ctx, &r->shown);
    gsf_free(ctx, r->prompt);
    gsf_free(ctx, r->references);
    gsf_free(ctx, r->texts);
    gsf_free(ctx, r);
}

// Copies the desc and its strings, which are stored one after another in r->texts.
static gsf_result gsf__dit_copy_desc(gsf_context* ctx, const gsf_nn_dit_desc* desc, gsf__dit_restorer* r) {
    r->desc = *desc;
    const char** const texts[] = {&r->desc.model, &r->desc.features, &r->desc.caption, &r->desc.save_features,
                                  &r->desc.sample.checkpoint};
    size_t size = 0;
    for (size_t i = 0; i < GSF__COUNT(texts); i++) size += *texts[i] ? strlen(*texts[i]) + 1 : 0;
    r->texts = (char*)gsf_alloc(ctx, size, 1);
    if (!r->texts) return GSF_ERROR_OUT_OF_MEMORY;
    char* at = r->texts;
    for (size_t i = 0; i < GSF__COUNT(texts); i++) {
        if (!*texts[i]) continue;
        const size_t bytes = strlen(*texts[i]) + 1;
        memcpy(at, *texts[i], bytes);
        *texts[i] = at;
        at += bytes;
    }
    return GSF_OK;
}

GSF_API gsf_result gsf_nn_make_dit(gsf_context* ctx, const gsf_nn_dit_desc* desc, gsf_restorer* out) {
    memset(out, 0, sizeof *out);
    if (!desc || !desc->model)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dit: no model folder given");
    gsf__dit_restorer* r = (gsf__dit_restorer*)gsf_alloc_zeroed(ctx, 1, sizeof *r);
    if (!r) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = gsf__dit_copy_desc(ctx, desc, r);
    if (!result) result = gsf__dit_open(ctx, r);
    out->struct_size = sizeof *out;
    out->name = "dit";
    out->user = r;
    out->query_fn = gsf__dit_query;
    out->begin_fn = gsf__dit_begin;
    out->restore_fn = gsf__dit_restore;
    out->end_fn = gsf__dit_end;
    if (result) gsf_nn_destroy_dit(ctx, out);
    return result;
}

// ---- >>nn metrics ---------------------------------------------------------------
// Networks that compare images, channels-last as in >>nn convolution. Every score is summed in double.

// ---- metrics: layers of feature maps

typedef struct gsf__map { // (images, height, width, channels)
    float* data;
    int64_t images, height, width, channels, pitch; // pitch: floats from pixel to pixel
} gsf__map;

// Floats of a dense map; SIZE_MAX, which no allocator can provide, on overflow.
static size_t gsf__map_count(const gsf__map* map) {
    return gsf__nn_product(gsf__nn_product((size_t)map->images, (size_t)map->height),
                           gsf__nn_product((size_t)map->width, (size_t)map->channels));
}

typedef struct gsf__maps { // buffers of a network, reused from image to image
    gsf_context* ctx;
    gsf__nn_workspace rooms[2], conv; // the maps that a layer reads and writes; its weights and bordered input
    int room;                         // that of the current map
    gsf__map now;
} gsf__maps;

static void gsf__destroy_maps(gsf_context* ctx, gsf__maps* maps) {
    gsf__nn_destroy_workspace(ctx, &maps->rooms[0]);
    gsf__nn_destroy_workspace(ctx, &maps->rooms[1]);
    gsf__nn_destroy_workspace(ctx, &maps->conv);
}

// Gives `map` the memory of the room that the current map does not use.
static gsf_result gsf__map_make(gsf__maps* maps, gsf__map* map) {
    map->data = (float*)gsf__nn_scratch(maps->ctx, &maps->rooms[!maps->room],
                                        gsf__nn_product(gsf__map_count(map), sizeof(float)));
    return map->data ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

static void gsf__map_use(gsf__maps* maps, const gsf__map* map) {
    maps->now = *map;
    maps->room = !maps->room;
}

typedef struct gsf__map_fill { // the input, dense and with `pad` columns of zeros on either side
    const gsf__map* x;
    float* out;
    int64_t image, pad;
    int rectify; // ReLU
} gsf__map_fill;

static void gsf__map_fill_row(void* arg, size_t row, int32_t worker) {
    const gsf__map_fill* job = (const gsf__map_fill*)arg;
    const gsf__map* map = job->x;
    const int64_t c = map->channels, edge = job->pad * c, count = map->width * c;
    const float* x = map->data + (job->image * map->height + (int64_t)row) * map->width * map->pitch;
    float* out = job->out + (int64_t)row * (count + 2 * edge);
    (void)worker;
    memset(out, 0, (size_t)edge * sizeof(float));
    memset(out + edge + count, 0, (size_t)edge * sizeof(float));
    out += edge;
    for (int64_t i = 0; i < (map->pitch == c ? 1 : map->width); i++)
        memcpy(out + i * c, x + i * map->pitch, (size_t)(map->pitch == c ? count : c) * sizeof(float));
    for (int64_t i = 0; i < count && job->rectify; i++) out[i] = out[i] < 0.0f ? 0.0f : out[i]; // a NaN remains
}

typedef struct gsf__map_conv { // a convolution; kernel and channels are those of the weight
    const gsf__nn_layer* layer;
    int64_t stride, pad;
    int rectify;              // ReLU of the input
    int64_t above, left;      // rows before and columns within the padded input at which output 0 begins
    int64_t ldo, out_row;     // floats from pixel to pixel, and from row to row, of the output
} gsf__map_conv;

// Writes y, of the sizes given there; y may be a part of x.
static gsf_result gsf__map_convolve_at(gsf_context* ctx, gsf__nn_workspace* workspace, const gsf__map_conv* c,
                                       const gsf__map* x, const gsf__map* y) {
    const gsf_nn_tensor* w = c->layer->weight;
    gsf__conv_layer layer = {w, c->layer->bias, w->shape[1], w->shape[0], 1, w->shape[2]};
    const int64_t across = x->width + 2 * c->pad, bordered = x->height * across * layer.in;
    float* memory = (float*)gsf__nn_scratch(ctx, workspace,
                                            ((size_t)gsf__conv_packed(&layer) + (size_t)bordered) * sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__conv_job job;
    gsf__map_fill fill = {x, memory, 0, c->pad, c->rectify};
    gsf__conv_pack(ctx, &layer, memory + bordered);
    memset(&job, 0, sizeof job);
    job.kernels = gsf__conv_kernels_of(ctx->cpu_level);
    job.in[0] = memory;
    job.in_height = x->height;
    job.in_stride = across * layer.in;
    job.origin = c->left * layer.in;
    job.step = c->stride * layer.in;
    job.kt = 1;
    job.kh = layer.kernel;
    job.k = layer.kernel * layer.in;
    job.stride = c->stride;
    job.pad = c->above;
    job.packed = memory + bordered;
    job.panel = gsf__conv_panel(&layer);
    job.height = y->height;
    job.width = y->width;
    job.outputs = layer.out;
    job.ldo = c->ldo;
    job.out_row = c->out_row;
    job.groups = 1;
    for (; fill.image < x->images; fill.image++) {
        gsf__parallel_for(ctx, (size_t)x->height, gsf__map_fill_row, &fill);
        job.out = y->data + fill.image * y->height * y->width * y->pitch;
        gsf__conv_frame(ctx, &job, NULL);
    }
    return GSF_OK;
}

static gsf_result gsf__map_convolve(gsf_context* ctx, gsf__nn_workspace* workspace, const gsf__nn_layer* layer,
                                    int64_t stride, int64_t pad, int rectify, const gsf__map* x, const gsf__map* y) {
    const gsf__map_conv c = {layer, stride, pad, rectify, pad, 0, y->pitch, y->width * y->pitch};
    return gsf__map_convolve_at(ctx, workspace, &c, x, y);
}

// Convolves the current map into a new one, which becomes the current one.
static gsf_result gsf__map_conv_next(gsf__maps* maps, const gsf__nn_layer* layer, int64_t stride, int64_t pad, int rectify) {
    const gsf_nn_tensor* w = layer->weight;
    const int64_t high = maps->now.height + 2 * pad - w->shape[2], wide = maps->now.width + 2 * pad - w->shape[2];
    gsf__map y = {NULL, maps->now.images, high / stride + 1, wide / stride + 1, w->shape[0], w->shape[0]};
    if (high < 0 || wide < 0)
        return gsf_fail(maps->ctx, GSF_ERROR_DEGENERATE, "%s: %lld x %lld values are too few", w->name,
                        (long long)maps->now.width, (long long)maps->now.height);
    GSF__TRY(gsf__map_make(maps, &y));
    GSF__TRY(gsf__map_convolve(maps->ctx, &maps->conv, layer, stride, pad, rectify, &maps->now, &y));
    gsf__map_use(maps, &y);
    return gsf__check_cancel(maps->ctx);
}

// ---- metrics: LPIPS

/* Learned perceptual image patch similarity, version 0.1 (Zhang et al. 2018; github.com/richzhang/PerceptualSimilarity,
   lpips/lpips.py): both images go through the convolutions of a classifier. After some of its layers, the taps, the features
   of each pixel are divided by their norm, and the squared differences are weighted by channel. The distance is the sum over
   taps of the mean over pixels. The networks are tables; ReLU follows every convolution and is applied where its result is
   used (it may move behind a max pool). */

typedef enum gsf__lpips_form { GSF__LPIPS_END = 0, GSF__LPIPS_CONV, GSF__LPIPS_POOL, GSF__LPIPS_FIRE } gsf__lpips_form;

typedef struct gsf__lpips_step {
    gsf__lpips_form form;
    int index;               // in torchvision's `features`
    int kernel, stride, pad; // pool: a stride of 2, rounded up where `pad` is set
    int tap;
} gsf__lpips_step;

#define GSF_C(index, kernel, stride, pad, tap) {GSF__LPIPS_CONV, index, kernel, stride, pad, tap}
#define GSF_P(kernel, up) {GSF__LPIPS_POOL, 0, kernel, 2, up, 0}
#define GSF_F(index, tap) {GSF__LPIPS_FIRE, index, 0, 1, 0, tap}
static const gsf__lpips_step gsf__lpips_alex[] = {
    GSF_C(0, 11, 4, 2, 1), GSF_P(3, 0), GSF_C(3, 5, 1, 2, 1), GSF_P(3, 0), GSF_C(6, 3, 1, 1, 1), GSF_C(8, 3, 1, 1, 1),
    GSF_C(10, 3, 1, 1, 1), {GSF__LPIPS_END, 0, 0, 0, 0, 0},
};
static const gsf__lpips_step gsf__lpips_vgg[] = {
    GSF_C(0, 3, 1, 1, 0), GSF_C(2, 3, 1, 1, 1), GSF_P(2, 0), GSF_C(5, 3, 1, 1, 0), GSF_C(7, 3, 1, 1, 1), GSF_P(2, 0),
    GSF_C(10, 3, 1, 1, 0), GSF_C(12, 3, 1, 1, 0), GSF_C(14, 3, 1, 1, 1), GSF_P(2, 0), GSF_C(17, 3, 1, 1, 0),
    GSF_C(19, 3, 1, 1, 0), GSF_C(21, 3, 1, 1, 1), GSF_P(2, 0), GSF_C(24, 3, 1, 1, 0), GSF_C(26, 3, 1, 1, 0),
    GSF_C(28, 3, 1, 1, 1), {GSF__LPIPS_END, 0, 0, 0, 0, 0},
};
static const gsf__lpips_step gsf__lpips_squeeze[] = { // SqueezeNet 1.1
    GSF_C(0, 3, 2, 0, 1), GSF_P(3, 1), GSF_F(3, 0), GSF_F(4, 1), GSF_P(3, 1), GSF_F(6, 0), GSF_F(7, 1), GSF_P(3, 1),
    GSF_F(9, 1), GSF_F(10, 1), GSF_F(11, 1), GSF_F(12, 1), {GSF__LPIPS_END, 0, 0, 0, 0, 0},
};
#undef GSF_C
#undef GSF_P
#undef GSF_F

static const struct {
    const char *name, *backbone, *heads; // files
    const gsf__lpips_step* steps;
} gsf__lpips_nets[] = {
    {"LPIPS (AlexNet)", "alexnet-owt-7be5be79", "alex", gsf__lpips_alex},
    {"LPIPS (VGG16)", "vgg16-397923af", "vgg", gsf__lpips_vgg},
    {"LPIPS (SqueezeNet)", "squeezenet1_1-b8a52dc0", "squeeze", gsf__lpips_squeeze},
};

enum { GSF__LPIPS_STEPS = 17, GSF__LPIPS_TAPS = 7 };

typedef struct gsf__lpips {
    gsf_nn_weights backbone, heads;
    gsf__nn_layer layers[GSF__LPIPS_STEPS][3]; // a convolution; fire: squeeze, expand1x1, expand3x3
    const gsf_nn_tensor* taps[GSF__LPIPS_TAPS];
    gsf__maps maps;
    double* partial; // (rows of the largest map)
    float* vectors;  // weights of a tap
    size_t partial_room, vectors_room;
} gsf__lpips;

static gsf_result gsf__lpips_need(gsf__nn_loader* loader, int index, const char* part, int64_t in, int64_t kernel,
                                  gsf__nn_layer* out) {
    const int64_t shape[4] = {-1, in, kernel, kernel};
    GSF__TRY(gsf__nn_need(loader, &out->weight, 4, shape, "features.%d%s.weight", index, part));
    if (out->weight->shape[0] < 1)
        return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensor %s is empty", loader->weights->name, out->weight->name);
    return gsf__nn_need(loader, &out->bias, 1, out->weight->shape, "features.%d%s.bias", index, part);
}

// Looks up the tensors of a network; *channels follows the channels from step to step.
static gsf_result gsf__lpips_bind(gsf__nn_loader* backbone, gsf__nn_loader* heads, const gsf__lpips_step* steps,
                                  gsf__lpips* net) {
    int64_t channels = 3;
    int taps = 0;
    for (int i = 0; steps[i].form; i++) {
        const gsf__lpips_step* s = &steps[i];
        gsf__nn_layer* layers = net->layers[i];
        if (s->form == GSF__LPIPS_CONV) {
            GSF__TRY(gsf__lpips_need(backbone, s->index, "", channels, s->kernel, &layers[0]));
            channels = layers[0].weight->shape[0];
        } else if (s->form == GSF__LPIPS_FIRE) {
            GSF__TRY(gsf__lpips_need(backbone, s->index, ".squeeze", channels, 1, &layers[0]));
            GSF__TRY(gsf__lpips_need(backbone, s->index, ".expand1x1", layers[0].weight->shape[0], 1, &layers[1]));
            GSF__TRY(gsf__lpips_need(backbone, s->index, ".expand3x3", layers[0].weight->shape[0], 3, &layers[2]));
            channels = layers[1].weight->shape[0] + layers[2].weight->shape[0];
        }
        const int64_t shape[4] = {1, channels, 1, 1};
        if (s->tap) GSF__TRY(gsf__nn_need(heads, &net->taps[taps], 4, shape, "lin%d.model.1.weight", taps));
        taps += s->tap;
    }
    gsf__nn_ignore(backbone, "classifier.");
    return GSF_OK;
}

static gsf_result gsf__lpips_open(gsf_context* ctx, const char* models, int kind, gsf__lpips* net) {
    gsf__nn_loader backbone, heads;
    GSF__TRY(gsf_nn_load_weights(ctx, models, gsf__lpips_nets[kind].backbone, &net->backbone));
    GSF__TRY(gsf_nn_load_weights(ctx, models, gsf__lpips_nets[kind].heads, &net->heads));
    GSF__TRY(gsf__nn_begin_loading(ctx, &net->backbone, &backbone));
    gsf_result result = gsf__nn_begin_loading(ctx, &net->heads, &heads);
    if (!result) {
        result = gsf__lpips_bind(&backbone, &heads, gsf__lpips_nets[kind].steps, net);
        result = gsf__nn_end_loading(&heads, result);
    }
    return gsf__nn_end_loading(&backbone, result);
}

static void gsf__lpips_close(gsf_context* ctx, void* state) {
    gsf__lpips* net = (gsf__lpips*)state;
    gsf_nn_destroy_weights(ctx, &net->backbone);
    gsf_nn_destroy_weights(ctx, &net->heads);
    gsf__destroy_maps(ctx, &net->maps);
    gsf_free(ctx, net->partial);
    gsf_free(ctx, net->vectors);
}

typedef struct gsf__map_pool_job {
    const gsf__map *x, *y;
    int64_t kernel;
} gsf__map_pool_job;

static void gsf__map_pool_row(void* arg, size_t row, int32_t worker) { // maxima of windows, 2 apart, cut at the border
    const gsf__map_pool_job* job = (const gsf__map_pool_job*)arg;
    const gsf__map *x = job->x, *y = job->y;
    const int64_t c = x->channels, image = (int64_t)row / y->height, y0 = (int64_t)row % y->height * 2;
    const int64_t y1 = gsf__least(y0 + job->kernel, x->height);
    (void)worker;
    for (int64_t column = 0; column < y->width; column++) {
        float* out = y->data + ((int64_t)row * y->width + column) * c;
        const int64_t x0 = column * 2, x1 = gsf__least(x0 + job->kernel, x->width);
        for (int64_t v = y0; v < y1; v++)
            for (int64_t u = x0; u < x1; u++) {
                const float* from = x->data + ((image * x->height + v) * x->width + u) * c;
                const int first = v == y0 && u == x0;
                for (int64_t i = 0; i < c; i++) out[i] = first || !(from[i] <= out[i]) ? from[i] : out[i];
            }
    }
}

// Windows of a pool along one side; with `up` the last may be cut, but as in PyTorch none begins outside.
static int64_t gsf__pool_size(int64_t size, int64_t kernel, int up) {
    const int64_t past = size - kernel + up;
    return past < 0 ? 0 : past / 2 * 2 < size ? past / 2 + 1 : past / 2;
}

static gsf_result gsf__map_pool_next(gsf__maps* maps, int64_t kernel, int up) {
    const gsf__map x = maps->now;
    gsf__map y = {NULL, x.images, gsf__pool_size(x.height, kernel, up), gsf__pool_size(x.width, kernel, up), x.channels,
                  x.channels};
    gsf__map_pool_job job = {&x, &y, kernel};
    if (y.height < 1 || y.width < 1)
        return gsf_fail(maps->ctx, GSF_ERROR_DEGENERATE, "max pool: %lld x %lld values are too few", (long long)x.width,
                        (long long)x.height);
    GSF__TRY(gsf__map_make(maps, &y));
    gsf__parallel_for(maps->ctx, (size_t)(y.images * y.height), gsf__map_pool_row, &job);
    gsf__map_use(maps, &y);
    return GSF_OK;
}

// Squeeze by 1 x 1; then 1 x 1 and 3 x 3 side by side.
static gsf_result gsf__lpips_fire(gsf__maps* maps, const gsf__nn_layer* layers) {
    const int64_t one = layers[1].weight->shape[0], three = layers[2].weight->shape[0];
    GSF__TRY(gsf__map_conv_next(maps, &layers[0], 1, 0, 1));
    gsf__map y = maps->now;
    y.channels = y.pitch = one + three;
    GSF__TRY(gsf__map_make(maps, &y));
    gsf__map part = y;
    GSF__TRY(gsf__map_convolve(maps->ctx, &maps->conv, &layers[1], 1, 0, 1, &maps->now, &part));
    part.data += one;
    GSF__TRY(gsf__map_convolve(maps->ctx, &maps->conv, &layers[2], 1, 1, 1, &maps->now, &part));
    gsf__map_use(maps, &y);
    return gsf__check_cancel(maps->ctx);
}

typedef struct gsf__lpips_tap_job {
    const gsf__map* map; // of two images
    const float* weights;
    double* partial;     // (height)
} gsf__lpips_tap_job;

static double gsf__lpips_norm(const float* x, int64_t count) { // of the rectified features
    double sums[4] = {0.0, 0.0, 0.0, 0.0};
    for (int64_t i = 0; i < count; i++) {
        const double v = x[i] < 0.0f ? 0.0 : (double)x[i];
        sums[i & 3] += v * v;
    }
    return sqrt(sums[0] + sums[1] + (sums[2] + sums[3])) + 1e-10;
}

static void gsf__lpips_tap_row(void* arg, size_t row, int32_t worker) {
    const gsf__lpips_tap_job* job = (const gsf__lpips_tap_job*)arg;
    const int64_t c = job->map->channels, width = job->map->width;
    const float *a = job->map->data + (int64_t)row * width * c, *b = a + job->map->height * width * c;
    double sum = 0.0;
    (void)worker;
    for (int64_t x = 0; x < width; x++, a += c, b += c) {
        const double of_a = 1.0 / gsf__lpips_norm(a, c), of_b = 1.0 / gsf__lpips_norm(b, c);
        double sums[4] = {0.0, 0.0, 0.0, 0.0};
        for (int64_t i = 0; i < c; i++) {
            const double d = (a[i] < 0.0f ? 0.0 : (double)a[i]) * of_a - (b[i] < 0.0f ? 0.0 : (double)b[i]) * of_b;
            sums[i & 3] += (double)job->weights[i] * d * d;
        }
        sum += sums[0] + sums[1] + (sums[2] + sums[3]);
    }
    job->partial[row] = sum;
}

// The weighted distance of the current map's two images.
static gsf_result gsf__lpips_measure_tap(gsf__lpips* net, const gsf_nn_tensor* weight, double* out) {
    gsf_context* ctx = net->maps.ctx;
    const gsf__map* map = &net->maps.now;
    GSF__TRY(gsf__reserve(ctx, (void**)&net->partial, &net->partial_room, 0, (size_t)map->height, sizeof(double)));
    GSF__TRY(gsf__reserve(ctx, (void**)&net->vectors, &net->vectors_room, 0, (size_t)weight->count, sizeof(float)));
    gsf_nn_convert_tensor(weight, 0, weight->count, net->vectors);
    gsf__lpips_tap_job job = {map, net->vectors, net->partial};
    gsf__parallel_for(ctx, (size_t)map->height, gsf__lpips_tap_row, &job);
    double sum = 0.0;
    for (int64_t i = 0; i < map->height; i++) sum += net->partial[i];
    *out = sum / ((double)map->height * (double)map->width);
    return GSF_OK;
}

// Stores an image of [0,1], scaled to [-1,1] unless `raw`, and normalised as the classifiers were trained.
static gsf_result gsf__lpips_store(gsf_context* ctx, const gsf_image* image, int raw, float* out) {
    static const double shift[3] = {-0.030, -0.088, -0.188}, scale[3] = {0.458, 0.448, 0.450};
    gsf_image packed = gsf_wrap_image(out, GSF_F32, image->width, image->height, 3);
    GSF__TRY(gsf_convert_image(ctx, image, &packed));
    for (int64_t i = 0; i < image->width * image->height; i++, out += 3)
        for (int c = 0; c < 3; c++)
            out[c] = (float)(((raw ? (double)out[c] : 2.0 * (double)out[c] - 1.0) - shift[c]) / scale[c]);
    return GSF_OK;
}

static gsf_result gsf__lpips_compare(gsf_context* ctx, const gsf_nn_metric* metric, const gsf_image* a, const gsf_image* b,
                                     double* out) {
    gsf__lpips* net = (gsf__lpips*)metric->state;
    gsf__maps* maps = &net->maps;
    const gsf__lpips_step* steps = gsf__lpips_nets[metric->kind].steps;
    gsf__map pair = {NULL, 2, a->height, a->width, 3, 3};
    float terms[GSF__LPIPS_TAPS];
    int taps = 0;
    *out = 0.0;
    maps->ctx = ctx;
    GSF__TRY(gsf__map_make(maps, &pair));
    GSF__TRY(gsf__lpips_store(ctx, a, metric->raw, pair.data));
    GSF__TRY(gsf__lpips_store(ctx, b, metric->raw, pair.data + a->height * a->width * 3));
    gsf__map_use(maps, &pair);
    for (int i = 0; steps[i].form; i++) {
        const gsf__lpips_step* s = &steps[i];
        double term;
        if (s->form == GSF__LPIPS_CONV)
            GSF__TRY(gsf__map_conv_next(maps, &net->layers[i][0], s->stride, s->pad, i > 0));
        else if (s->form == GSF__LPIPS_POOL) GSF__TRY(gsf__map_pool_next(maps, s->kernel, s->pad));
        else GSF__TRY(gsf__lpips_fire(maps, net->layers[i]));
        if (!s->tap) continue;
        GSF__TRY(gsf__lpips_measure_tap(net, net->taps[taps], &term));
        if (metric->_tap)
            for (int k = 0; k < 2; k++)
                metric->_tap->fn(metric->_tap->user, "features", 2 * taps + k,
                                 maps->now.data + k * maps->now.height * maps->now.width * maps->now.channels,
                                 maps->now.height * maps->now.width, maps->now.channels);
        terms[taps++] = (float)term;
        *out += term;
    }
    if (metric->_tap) metric->_tap->fn(metric->_tap->user, "terms", 0, terms, 1, taps);
    return GSF_OK;
}

static gsf_result gsf__lpips_measure(gsf_context* ctx, gsf_nn_metric* metric, const gsf_image* frame,
                                     const gsf_image* reference) {
    const char* name = gsf__lpips_nets[metric->kind].name;
    double value;
    if (!reference || frame->width != reference->width || frame->height != reference->height)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: two images of one size are needed", name);
    GSF__TRY(gsf__lpips_compare(ctx, metric, frame, reference, &value));
    if (!(fabs(value) <= DBL_MAX)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: the distance is %g", name, value);
    metric->last = value;
    metric->score += (value - metric->score) / (double)++metric->count;
    return GSF_OK;
}

// ---- metrics: image encoders

/* Vision transformers under the names of DINO (Caron et al. 2021; github.com/facebookresearch/dino vision_transformer.py),
   in which DreamSim also publishes its CLIP models. The feature of an image is its class token: after the final norm, and
   projected where the file has `proj`. Sizes follow from the tensors, heads have 64 channels. */

typedef struct gsf__tower_form { // what the file does not say
    const char* file;
    float eps;
    gsf__nn_activation activation;
    const float *mean, *deviation; // of the pixels
    int clip, no_norm; // CLIP: a norm before the blocks and a projection; the class token is taken before the final norm
} gsf__tower_form;

typedef struct gsf__tower {
    gsf_nn_weights weights;
    gsf__vit vit;
    const gsf_nn_tensor* projection; // (width, features) or NULL
    int64_t features;
    gsf_nn_tensor* qkv; // (layers) weights with their LoRA added, owned; NULL: those of the file
    int no_norm;
} gsf__tower;

static const gsf__nn_entry gsf__tower_block_entries[] = { // below blocks.N.
    {"norm1", "d", GSF__NN_BLOCK(norm1)},
    {"norm2", "d", GSF__NN_BLOCK(norm2)},
    {"attn.qkv", "td", GSF__NN_BLOCK(qkv)},
    {"attn.proj", "dd", GSF__NN_BLOCK(out)},
    {"mlp.fc1", "md", GSF__NN_BLOCK(up)},
    {"mlp.fc2", "dm", GSF__NN_BLOCK(down)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__tower_entries[] = {
    {"cls_token", "11d", GSF__VIT_TENSOR(class_token)},
    {"pos_embed", "1sd", GSF__VIT_TENSOR(positions)},
    {"patch_embed.proj", "dcpp", GSF__NN_AT(gsf__vit, patches)},
    {"norm", "d", GSF__NN_AT(gsf__vit, norm)},
    GSF__NN_END,
};

static const gsf__nn_entry gsf__tower_clip_entries[] = {{"pos_drop", "d", GSF__NN_AT(gsf__vit, pre_norm)}, GSF__NN_END};

// Width, patch and grid come from the tensors that embed the image.
static gsf_result gsf__tower_infer(gsf__nn_loader* loader, const gsf_nn_tensor* patches, const gsf_nn_tensor* positions,
                                   int64_t position_count, int64_t mlp, int32_t heads, gsf__vit* vit) {
    gsf__nn_block_sizes* s = &vit->sizes;
    s->width = patches->shape[0];
    s->mlp = mlp;
    s->heads = heads ? heads : (int32_t)gsf__least(s->width / 64, 4096);
    vit->channels = patches->shape[1];
    vit->patch = patches->shape[patches->rank - 1];
    vit->grid = (int64_t)floor(sqrt((double)position_count - 0.5));
    const int fits = s->heads > 0 && s->width % s->heads == 0 && s->width < 1 << 16 && vit->channels == 3 &&
                     vit->patch > 0 && vit->patch < 1024 && vit->grid > 0 && vit->grid < 1024 &&
                     vit->grid * vit->grid + 1 == position_count && vit->layers > 0 && mlp > 0;
    if (!fits)
        return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensors %s and %s do not fit a vision transformer",
                        loader->weights->name, patches->name, positions->name);
    s->head_dim = (int32_t)(s->width / s->heads);
    return GSF_OK;
}

static gsf_result gsf__tower_bind(gsf__nn_loader* loader, const gsf__tower_form* form, int32_t heads, gsf__tower* tower) {
    static const int64_t any[4] = {-1, -1, -1, -1};
    const gsf_nn_tensor *patches, *positions, *up;
    gsf__vit* vit = &tower->vit;
    GSF__TRY(gsf__nn_need(loader, &patches, 4, any, "patch_embed.proj.weight"));
    GSF__TRY(gsf__nn_need(loader, &positions, 3, any, "pos_embed"));
    GSF__TRY(gsf__nn_need(loader, &up, 2, any, "blocks.0.mlp.fc1.weight"));
    vit->layers = gsf__nn_count_blocks(loader->weights, "blocks.");
    GSF__TRY(gsf__tower_infer(loader, patches, positions, positions->shape[1], up->shape[0], heads, vit));
    vit->sizes.eps = form->eps;
    vit->sizes.activation = form->activation;
    vit->sizes.qkv_bias = 1;
    vit->block_names = "blocks.";
    vit->prefix = "patch_embed.";
    vit->mean = form->mean;
    vit->deviation = form->deviation;
    tower->features = vit->sizes.width;
    tower->no_norm = form->no_norm;
    GSF__TRY(gsf__vit_bind(loader, gsf__tower_entries, gsf__tower_block_entries, "", vit));
    vit->register_tokens = vit->class_token; // never read, as there are 0 registers
    if (!form->clip) return GSF_OK;
    const gsf__nn_sizes sizes = gsf__vit_sizes(vit);
    const int64_t shape[2] = {vit->sizes.width, -1};
    GSF__TRY(gsf__nn_bind(loader, &sizes, gsf__tower_clip_entries, "", vit));
    GSF__TRY(gsf__nn_need(loader, &tower->projection, 2, shape, "proj"));
    tower->features = tower->projection->shape[1];
    return GSF_OK;
}

static gsf_result gsf__tower_open(gsf_context* ctx, const char* models, const gsf__tower_form* form, int32_t heads,
                                  gsf__tower* tower) {
    gsf__nn_loader loader;
    GSF__TRY(gsf_nn_load_weights(ctx, models, form->file, &tower->weights));
    GSF__TRY(gsf__nn_begin_loading(ctx, &tower->weights, &loader));
    return gsf__nn_end_loading(&loader, gsf__tower_bind(&loader, form, heads, tower));
}

static void gsf__tower_close(gsf_context* ctx, gsf__tower* tower) {
    for (int64_t i = 0; tower->qkv && i < tower->vit.layers; i++) gsf_free(ctx, (void*)(uintptr_t)tower->qkv[i].data);
    gsf_free(ctx, tower->qkv);
    gsf_free(ctx, tower->vit.blocks);
    gsf_nn_destroy_weights(ctx, &tower->weights);
}

// out (columns) = row (rows) times a matrix (rows, columns), in double.
static gsf_result gsf__project_row(gsf_context* ctx, const float* row, const gsf_nn_tensor* matrix, float* out) {
    const int64_t rows = matrix->shape[0], columns = matrix->shape[1];
    double* sums = (double*)gsf_alloc_zeroed(ctx, (size_t)columns, sizeof(double) + sizeof(float));
    if (!sums) return GSF_ERROR_OUT_OF_MEMORY;
    float* wide = (float*)(void*)(sums + columns);
    for (int64_t r = 0; r < rows; r++) {
        gsf_nn_convert_tensor(matrix, r * columns, columns, wide);
        for (int64_t c = 0; c < columns; c++) sums[c] += (double)row[r] * (double)wide[c];
    }
    for (int64_t c = 0; c < columns; c++) out[c] = (float)sums[c];
    gsf_free(ctx, sums);
    return GSF_OK;
}

// The feature of an image (3, height, width) in [0,1]: out (features).
static gsf_result gsf__tower_encode(gsf_context* ctx, const char* name, const gsf__tower* tower, const float* pixels,
                                    int64_t height, int64_t width, const gsf__nn_tap* tap, float* out) {
    const gsf__vit* vit = &tower->vit;
    gsf_nn_encoder_desc in;
    gsf__nn_run run;
    gsf__vit_plan plan;
    float* memory = NULL;
    memset(&in, 0, sizeof in);
    memset(&run, 0, sizeof run);
    in.pixels = pixels;
    in.images = 1;
    in.height = (int32_t)height;
    in.width = (int32_t)width;
    run.ctx = ctx;
    run.name = run.stage = name;
    run.weights = &tower->weights;
    run.tap = tap;
    run.steps = (double)vit->layers;
    gsf_result result = gsf__vit_check_input(ctx, name, vit->channels, vit->patch, &in, out);
    if (!result) result = gsf__vit_open_run(&run, vit, NULL, &in, &plan, &memory);
    if (!result) result = gsf__vit_forward(&run, vit, &in, 0, 1, plan.positions, plan.x);
    if (!result && !tower->no_norm) gsf__nn_norm(&run, &vit->norm, vit->sizes.eps, plan.x, 1, plan.x);
    if (!result && tower->projection) result = gsf__project_row(ctx, plan.x, tower->projection, out);
    else if (!result) memcpy(out, plan.x, (size_t)tower->features * sizeof(float));
    if (!result) result = gsf__nn_check(&run, "feature", "", out, tower->features);
    gsf__nn_destroy_workspace(ctx, &run.workspace);
    gsf_free(ctx, memory);
    return result;
}

// ---- metrics: consistency with an image (VBench, vbench2_beta_i2v)

/* I2V subject takes the features of DINO ViT-B/16, I2V background those of DreamSim's ensemble (Fu et al. 2023): DINO, CLIP
   and OpenCLIP ViT-B/16 with LoRA, concatenated, less their mean, divided by their norm. With the cosines c_t to the input
   image and s_t to the frame before, both at least 0, the score is 0.4 max c + 0.3 mean s + 0.3 min s. VBench resizes the
   input image as PIL does, in 8 bits, but frames as float tensors, neither rounded nor clamped. */

enum { GSF__I2V_SIDE = 224, GSF__I2V_SHORT = 256, GSF__I2V_TOWERS = 3 };

static const float gsf__clip_mean[3] = {0.48145466f, 0.4578275f, 0.40821073f},
                   gsf__clip_deviation[3] = {0.26862954f, 0.26130258f, 0.27577711f};

static const gsf__tower_form gsf__i2v_subject[] = {
    {"dino_vitbase16_pretrain", 1e-6f, GSF__NN_GELU, gsf__imagenet_mean, gsf__imagenet_deviation, 0, 0},
};
static const gsf__tower_form gsf__i2v_background[] = {
    {"dino_vitbase16_pretrain", 1e-6f, GSF__NN_GELU, gsf__imagenet_mean, gsf__imagenet_deviation, 0, 1},
    {"clip_vitb16_pretrain", 1e-5f, GSF__NN_QUICK_GELU, gsf__clip_mean, gsf__clip_deviation, 1, 0},
    {"open_clip_vitb16_pretrain", 1e-5f, GSF__NN_GELU, gsf__clip_mean, gsf__clip_deviation, 1, 0},
};

typedef struct gsf__i2v {
    gsf__tower towers[GSF__I2V_TOWERS];
    int count;
    int64_t features;
    float* values;  // (3, features): of the input image, of the frame before, of this frame
    float* pixels;  // (3, 224, 224)
    double most, sum, least; // of the cosines
    int64_t frames; // including the input image
} gsf__i2v;

// Adds the LoRA of a tower's qkv layers: W + alpha / r B A.
static gsf_result gsf__i2v_merge(gsf__nn_loader* loader, int index, int64_t rank, double scale, gsf__tower* tower) {
    gsf_context* ctx = loader->ctx;
    const int64_t d = tower->vit.sizes.width, shape_a[2] = {rank, d}, shape_b[2] = {3 * d, rank};
    tower->qkv = (gsf_nn_tensor*)gsf_alloc_zeroed(ctx, (size_t)tower->vit.layers, sizeof *tower->qkv);
    float* a = (float*)gsf_alloc(ctx, (size_t)(rank * (d + 1)), sizeof(float)); // A, and a row of B
    gsf_result result = tower->qkv && a ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (int64_t i = 0; i < tower->vit.layers && !result; i++) {
        static const char name[] = "base_model.model.extractor_list.%d.model.blocks.%lld.attn.qkv.lora_%c.weight";
        const gsf_nn_tensor *down, *up, *weight = tower->vit.blocks[i].qkv.weight;
        result = gsf__nn_need(loader, &down, 2, shape_a, name, index, (long long)i, 'A');
        if (!result) result = gsf__nn_need(loader, &up, 2, shape_b, name, index, (long long)i, 'B');
        float* merged = result ? NULL : (float*)gsf_alloc(ctx, (size_t)weight->count, sizeof(float));
        if (!result && !merged) result = GSF_ERROR_OUT_OF_MEMORY;
        if (result) break;
        gsf_nn_convert_tensor(weight, 0, weight->count, merged);
        gsf_nn_convert_tensor(down, 0, down->count, a);
        for (int64_t row = 0; row < 3 * d; row++) {
            gsf_nn_convert_tensor(up, row * rank, rank, a + rank * d);
            for (int64_t column = 0; column < d; column++) {
                double sum = 0.0;
                for (int64_t k = 0; k < rank; k++) sum += (double)a[rank * d + k] * (double)a[k * d + column];
                merged[row * d + column] = (float)((double)merged[row * d + column] + scale * sum);
            }
        }
        tower->qkv[i] = gsf_nn_wrap_tensor(weight->name, merged, 2, weight->shape);
        tower->vit.blocks[i].qkv.weight = &tower->qkv[i];
    }
    gsf_free(ctx, a);
    return result;
}

static gsf_result gsf__i2v_open_adapter(gsf_context* ctx, const char* models, gsf__i2v* net) {
    gsf_buffer folder;
    gsf__nn_config config;
    gsf__nn_loader loader;
    gsf_nn_weights weights;
    int64_t rank = 1;
    double alpha = 1.0;
    memset(&weights, 0, sizeof weights);
    memset(&config, 0, sizeof config);
    config.ctx = ctx;
    gsf_result result = gsf__nn_join(ctx, models, "ensemble_lora", &folder);
    if (!result) result = gsf__nn_open_config(ctx, folder.data, "adapter_config.json", 0, &config);
    if (!result) {
        const gsf__nn_key keys[] = {GSF__KEY_INT("r", rank, 1, 4096), GSF__KEY_REAL_OR("lora_alpha", alpha, 8.0, 0.0, 1e6),
                                    GSF__KEY_FLAG_IS("use_rslora", 0, 0), GSF__KEY_FLAG_IS("use_dora", 0, 0)};
        result = gsf__nn_config_read(&config, keys, GSF__COUNT(keys));
    }
    gsf__nn_close_config(&config);
    if (!result) result = gsf_nn_load_weights(ctx, folder.data, "adapter_model", &weights);
    if (!result) result = gsf__nn_begin_loading(ctx, &weights, &loader);
    if (!result) {
        for (int i = 0; i < net->count && !result; i++)
            result = gsf__i2v_merge(&loader, i, rank, alpha / (double)rank, &net->towers[i]);
        result = gsf__nn_end_loading(&loader, result);
    }
    gsf_nn_destroy_weights(ctx, &weights);
    gsf_destroy_buffer(ctx, &folder);
    return result;
}

static gsf_result gsf__i2v_open(gsf_context* ctx, const gsf_nn_metric* metric, void* state) {
    gsf__i2v* net = (gsf__i2v*)state;
    const int background = metric->kind == GSF_NN_METRIC_I2V_BACKGROUND;
    const gsf__tower_form* forms = background ? gsf__i2v_background : gsf__i2v_subject;
    const int count = background ? GSF__I2V_TOWERS : 1;
    for (; net->count < count; net->count++) {
        gsf__tower* tower = &net->towers[net->count];
        const gsf_result result =
            gsf__tower_open(ctx, metric->models, &forms[net->count], metric->_heads ? metric->_heads[net->count] : 0, tower);
        net->features += tower->features;
        if (result) {
            net->count++; // to close it
            return result;
        }
    }
    if (background) GSF__TRY(gsf__i2v_open_adapter(ctx, metric->models, net));
    net->values = (float*)gsf_alloc(ctx, 3 * (size_t)net->features, sizeof(float));
    net->pixels = (float*)gsf_alloc(ctx, 3 * GSF__I2V_SIDE * GSF__I2V_SIDE, sizeof(float));
    return net->values && net->pixels ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

static void gsf__i2v_close(gsf_context* ctx, void* state) {
    gsf__i2v* net = (gsf__i2v*)state;
    for (int i = 0; i < net->count; i++) gsf__tower_close(ctx, &net->towers[i]);
    gsf_free(ctx, net->values);
    gsf_free(ctx, net->pixels);
}

// Resizes to 224 x 224: whole, or the centre of the image with its shorter side at 256. pixels: (3, 224, 224) in [0,1]
static gsf_result gsf__i2v_prepare(gsf_context* ctx, const gsf_image* image, int whole, gsf_dtype dtype, float* pixels) {
    const int64_t side = GSF__I2V_SIDE, brief = GSF__I2V_SHORT, w = image->width, h = image->height;
    const int64_t across = whole ? side : w <= h ? brief : brief * w / h, down = whole ? side : w <= h ? brief * h / w : brief;
    const int64_t left = (int64_t)rint((double)(across - side) / 2.0), top = (int64_t)rint((double)(down - side) / 2.0);
    gsf_image same, resized;
    memset(&same, 0, sizeof same);
    memset(&resized, 0, sizeof resized);
    gsf_result result = gsf_make_image(ctx, dtype, w, h, 3, &same);
    if (!result) result = gsf_convert_image(ctx, image, &same);
    if (!result) result = gsf_make_image(ctx, dtype, across, down, 3, &resized);
    if (!result) result = gsf_resize_image(ctx, &same, GSF_RESIZE_PIL_BICUBIC, &resized);
    for (int64_t c = 0; c < 3 && !result; c++)
        for (int64_t y = 0; y < side; y++)
            for (int64_t x = 0; x < side; x++, pixels++) {
                const char* at = (const char*)resized.data + (y + top) * resized.stride_y + (x + left) * resized.stride_x +
                                 c * resized.stride_c;
                if (dtype == GSF_U8) *pixels = (float)*(const uint8_t*)at / 255.0f;
                else memcpy(pixels, at, sizeof *pixels);
            }
    gsf_destroy_image(ctx, &same);
    gsf_destroy_image(ctx, &resized);
    return result;
}

static gsf_result gsf__i2v_encode(gsf_context* ctx, const gsf_nn_metric* metric, const gsf_image* image, gsf_dtype dtype,
                                  float* out) {
    gsf__i2v* net = (gsf__i2v*)metric->state;
    const char* name = net->count > 1 ? "i2v background" : "i2v subject";
    float* feature = out;
    GSF__TRY(gsf__i2v_prepare(ctx, image, net->count > 1, dtype, net->pixels));
    if (metric->_tap)
        metric->_tap->fn(metric->_tap->user, "pixels", (int32_t)net->frames, net->pixels, 3, GSF__I2V_SIDE * GSF__I2V_SIDE);
    for (int i = 0; i < net->count; i++) {
        const gsf__nn_tap* tap = net->frames == 0 ? metric->_tap : NULL; // layers of the input image only
        GSF__TRY(gsf__tower_encode(ctx, name, &net->towers[i], net->pixels, GSF__I2V_SIDE, GSF__I2V_SIDE, tap, feature));
        if (tap) tap->fn(tap->user, "tower", i, feature, 1, net->towers[i].features);
        feature += net->towers[i].features;
    }
    if (net->count > 1) {
        double mean = 0.0, square = 0.0;
        for (int64_t i = 0; i < net->features; i++) mean += (double)out[i] / (double)net->features;
        for (int64_t i = 0; i < net->features; i++) square += ((double)out[i] - mean) * ((double)out[i] - mean);
        for (int64_t i = 0; i < net->features; i++) out[i] = (float)(((double)out[i] - mean) / sqrt(square));
    }
    if (metric->_tap) metric->_tap->fn(metric->_tap->user, "feature", (int32_t)net->frames, out, 1, net->features);
    return GSF_OK;
}

static double gsf__cosine(const float* a, const float* b, int64_t count) {
    double product = 0.0, of_a = 0.0, of_b = 0.0;
    for (int64_t i = 0; i < count; i++) {
        product += (double)a[i] * (double)b[i];
        of_a += (double)a[i] * (double)a[i];
        of_b += (double)b[i] * (double)b[i];
    }
    return product / sqrt(of_a * of_b);
}

static double gsf__not_below_zero(double x) { return x < 0.0 ? 0.0 : x; } // a NaN remains

static gsf_result gsf__i2v_measure(gsf_context* ctx, gsf_nn_metric* metric, const gsf_image* frame,
                                   const gsf_image* reference) {
    gsf__i2v* net = (gsf__i2v*)metric->state;
    const size_t bytes = (size_t)net->features * sizeof(float);
    float *input = net->values, *before = input + net->features, *now = before + net->features;
    if (net->frames == 0) {
        if (!reference)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "i2v: the first frame needs the input image as its reference");
        GSF__TRY(gsf__i2v_encode(ctx, metric, reference, GSF_U8, input));
        net->frames = 1;
    }
    GSF__TRY(gsf__i2v_encode(ctx, metric, frame, GSF_F32, now));
    const double to_input = gsf__not_below_zero(gsf__cosine(input, now, net->features));
    const double to_last = net->frames > 1 ? gsf__not_below_zero(gsf__cosine(before, now, net->features)) : 0.0;
    if (!(to_input + to_last <= 3.0)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "i2v: a feature is 0 or not finite");
    if (to_input > net->most) net->most = to_input;
    if (net->frames == 2 || (net->frames > 2 && to_last < net->least)) net->least = to_last;
    net->sum += to_last;
    memcpy(before, now, bytes);
    metric->last = to_input;
    metric->count = net->frames++;
    if (metric->count > 1)
        metric->score = 0.4 * net->most + 0.3 * net->sum / (double)(metric->count - 1) + 0.3 * net->least;
    return GSF_OK;
}

// ---- metrics: AMT-S

/* The frame between two others (Li et al. 2023, AMT; VBench third_party/amt/networks/AMT-S.py): flows from the middle to both
   images, refined coarse to fine. At each of three scales, correlations of the images' features are looked up around where
   the flows lead and update flows and features. The volume of all correlations is never made: a pooled volume equals the
   correlation with pooled features, so each lookup computes the 8 x 8 products around its point. */

enum { GSF__AMT_LEVELS = 4, GSF__AMT_RADIUS = 3, GSF__AMT_WINDOW = 2 * GSF__AMT_RADIUS + 1, GSF__AMT_FLOWS = 3,
       GSF__AMT_SCALES = 4, GSF__AMT_ROOMS = 64,
       GSF__AMT_LOOKUP = GSF__AMT_LEVELS * GSF__AMT_WINDOW * GSF__AMT_WINDOW, // channels for each image
       GSF__AMT_STEP = 16, GSF__AMT_LEAST = 128 };                             // of the padded size

typedef struct gsf__amt_conv { // a convolution and its PReLU, whose slope is per channel
    gsf__nn_layer conv;
    const gsf_nn_tensor* slope; // NULL: another activation, or none
} gsf__amt_conv;

typedef struct gsf__amt_bottleneck { gsf__amt_conv convs[3], down; } gsf__amt_bottleneck; // down: no weight, if not needed

typedef struct gsf__amt_decoder {
    gsf__amt_conv first, convs[5]; // the last one's slope is that of the sum
    gsf__nn_layer up;              // transposed: (in, out, 4, 4)
} gsf__amt_decoder;

typedef struct gsf__amt_update { gsf__nn_layer c1, f1, f2, conv, gru[2], feature[2], flow[2]; } gsf__amt_update;

typedef struct gsf__amt {
    gsf_nn_weights weights;
    gsf__amt_conv stem, head;             // of the features to correlate
    gsf__amt_bottleneck bottlenecks[6];
    gsf__amt_conv pyramid[GSF__AMT_SCALES][2];
    gsf__amt_decoder decoders[GSF__AMT_SCALES]; // [0] works at 1/2 and gives whole pixels, [3] at 1/16
    gsf__amt_update updates[GSF__AMT_SCALES];   // [0] is unused
    gsf__amt_conv merge[2];
    gsf_context* ctx;
    const gsf__nn_tap* tap;
    gsf__nn_workspace conv, rooms[GSF__AMT_ROOMS]; // maps in the order of their making, reused by the next pair
    int room;
    // the stream
    gsf_image even, odd, middle; // the last frame of even number, the one after it (u8), and that as it should be
    double sum;
    int64_t frames;
} gsf__amt;

// ---- AMT-S: maps

static gsf_result gsf__amt_make(gsf__amt* net, int64_t images, int64_t height, int64_t width, int64_t channels,
                                gsf__map* out) {
    const gsf__map map = {NULL, images, height, width, channels, channels};
    *out = map;
    GSF_ASSERT(net->room < GSF__AMT_ROOMS);
    out->data = (float*)gsf__nn_scratch(net->ctx, &net->rooms[net->room++],
                                        gsf__nn_product(gsf__map_count(out), sizeof(float)));
    return out->data ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

static gsf__map gsf__map_slice(const gsf__map* map, int64_t first, int64_t channels) {
    gsf__map slice = *map;
    slice.data += first;
    slice.channels = channels;
    return slice;
}

static gsf__map gsf__map_image(const gsf__map* map, int64_t index) {
    gsf__map image = *map;
    image.data += index * map->height * map->width * map->pitch;
    image.images = 1;
    return image;
}

typedef struct gsf__amt_row_job { // of elementwise layers
    const gsf__map *x, *x2, *y;
    const float* slope; // per channel, or one for all
    float leak;
    double scale;       // of a resize: pixels of x per pixel of y
    float by;
    const double* moments;
} gsf__amt_row_job;

static float* gsf__map_row(const gsf__map* map, size_t row) { return map->data + (int64_t)row * map->width * map->pitch; }

static void gsf__amt_activate_row(void* arg, size_t row, int32_t worker) { // in place: x < 0 times its slope
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    float* y = gsf__map_row(job->y, row);
    (void)worker;
    for (int64_t x = 0; x < job->y->width; x++, y += job->y->pitch)
        for (int64_t c = 0; c < job->y->channels; c++)
            y[c] = y[c] < 0.0f ? y[c] * (job->slope ? job->slope[c] : job->leak) : y[c];
}

// PReLU with a slope per channel; NULL: `leak` for all, which is 0 for ReLU.
static gsf_result gsf__amt_activate(gsf__amt* net, const gsf_nn_tensor* slope, float leak, const gsf__map* y) {
    float slopes[1024];
    gsf__amt_row_job job;
    memset(&job, 0, sizeof job);
    if (slope && slope->count > 1024)
        return gsf_fail(net->ctx, GSF_ERROR_UNSUPPORTED, "%s: more than 1024 channels", slope->name);
    if (slope) gsf_nn_convert_tensor(slope, 0, slope->count, slopes);
    job.y = y;
    job.slope = slope ? slopes : NULL;
    job.leak = leak;
    gsf__parallel_for(net->ctx, (size_t)(y->images * y->height), gsf__amt_activate_row, &job);
    return gsf__check_cancel(net->ctx);
}

static void gsf__amt_copy_row(void* arg, size_t row, int32_t worker) {
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    const float* x = gsf__map_row(job->x, row);
    float* y = gsf__map_row(job->y, row);
    (void)worker;
    for (int64_t i = 0; i < job->y->width; i++, x += job->x->pitch, y += job->y->pitch)
        memcpy(y, x, (size_t)job->y->channels * sizeof(float));
}

static void gsf__amt_copy(gsf__amt* net, const gsf__map* x, const gsf__map* y) {
    gsf__amt_row_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.y = y;
    gsf__parallel_for(net->ctx, (size_t)(y->images * y->height), gsf__amt_copy_row, &job);
}

static void gsf__amt_add_row(void* arg, size_t row, int32_t worker) {
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    const float* x = gsf__map_row(job->x, row);
    float* y = gsf__map_row(job->y, row);
    (void)worker;
    for (int64_t i = 0; i < job->y->width; i++, x += job->x->pitch, y += job->y->pitch)
        for (int64_t c = 0; c < job->y->channels; c++) y[c] += x[c];
}

static void gsf__amt_add(gsf__amt* net, const gsf__map* x, const gsf__map* y) { // y += x
    gsf__amt_row_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.y = y;
    gsf__parallel_for(net->ctx, (size_t)(y->images * y->height), gsf__amt_add_row, &job);
}

// The pixels left of and right of a coordinate, and the share of the right one.
typedef struct gsf__between { int64_t low, high; float share; } gsf__between;

static gsf__between gsf__look_between(double x, int64_t size) { // clamped to the border
    gsf__between b;
    x = x > 0.0 ? x : 0.0; // also of a NaN
    x = x < (double)(size - 1) ? x : (double)(size - 1);
    b.low = (int64_t)x;
    b.high = gsf__least(b.low + 1, size - 1);
    b.share = (float)(x - (double)b.low);
    return b;
}

// y = by * bilinear interpolation of x (height and width of row 0) at a point; `channels` values
static void gsf__map_sample(const gsf__map* x, gsf__between v, gsf__between u, float by, int64_t channels, float* y) {
    const float *a = x->data + (v.low * x->width + u.low) * x->pitch,
                *b = x->data + (v.low * x->width + u.high) * x->pitch;
    const float *c = x->data + (v.high * x->width + u.low) * x->pitch,
                *d = x->data + (v.high * x->width + u.high) * x->pitch;
    for (int64_t i = 0; i < channels; i++) {
        const float top = a[i] + (b[i] - a[i]) * u.share, bottom = c[i] + (d[i] - c[i]) * u.share;
        y[i] = by * (top + (bottom - top) * v.share);
    }
}

static void gsf__amt_resize_row(void* arg, size_t row, int32_t worker) {
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    float* y = gsf__map_row(job->y, row);
    const gsf__between v = gsf__look_between(((double)row + 0.5) * job->scale - 0.5, job->x->height);
    (void)worker;
    for (int64_t i = 0; i < job->y->width; i++, y += job->y->pitch)
        gsf__map_sample(job->x, v, gsf__look_between(((double)i + 0.5) * job->scale - 0.5, job->x->width), job->by,
                        job->y->channels, y);
}

// y = by * x resized bilinearly, without antialiasing, as PyTorch does it (align_corners=False); one image
static void gsf__amt_resize(gsf__amt* net, const gsf__map* x, double scale, double by, const gsf__map* y) {
    gsf__amt_row_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.y = y;
    job.scale = 1.0 / scale;
    job.by = (float)by;
    gsf__parallel_for(net->ctx, (size_t)y->height, gsf__amt_resize_row, &job);
}

static void gsf__amt_warp_row(void* arg, size_t row, int32_t worker) { // x2: the flow
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    const float* flow = gsf__map_row(job->x2, row);
    float* y = gsf__map_row(job->y, row);
    (void)worker;
    for (int64_t i = 0; i < job->y->width; i++, y += job->y->pitch, flow += job->x2->pitch)
        gsf__map_sample(job->x, gsf__look_between((double)row + (double)flow[1], job->x->height),
                        gsf__look_between((double)i + (double)flow[0], job->x->width), 1.0f, job->y->channels, y);
}

static void gsf__amt_warp(gsf__amt* net, const gsf__map* x, const gsf__map* flow, const gsf__map* y) {
    gsf__amt_row_job job;
    memset(&job, 0, sizeof job);
    job.x = x;
    job.x2 = flow;
    job.y = y;
    gsf__parallel_for(net->ctx, (size_t)y->height, gsf__amt_warp_row, &job);
}

static void gsf__amt_sum_channel(void* arg, size_t chunk, int32_t worker) { // mean and deviation of a channel of an image
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    const gsf__map* y = job->y;
    const int64_t image = (int64_t)chunk / y->channels, pixels = y->height * y->width;
    const float* from = y->data + image * pixels * y->pitch + (int64_t)chunk % y->channels;
    double sum = 0.0, square = 0.0, *out = (double*)(uintptr_t)job->moments + 2 * chunk;
    (void)worker;
    for (int64_t i = 0; i < pixels; i++) sum += (double)from[i * y->pitch];
    const double mean = sum / (double)pixels;
    for (int64_t i = 0; i < pixels; i++) square += ((double)from[i * y->pitch] - mean) * ((double)from[i * y->pitch] - mean);
    out[0] = mean;
    out[1] = 1.0 / sqrt(square / (double)pixels + 1e-5);
}

static void gsf__amt_norm_row(void* arg, size_t row, int32_t worker) {
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    const double* moments = job->moments + (int64_t)row / job->y->height * 2 * job->y->channels;
    float* y = gsf__map_row(job->y, row);
    (void)worker;
    for (int64_t x = 0; x < job->y->width; x++, y += job->y->pitch)
        for (int64_t c = 0; c < job->y->channels; c++) {
            const float v = (float)(((double)y[c] - moments[2 * c]) * moments[2 * c + 1]);
            y[c] = v < 0.0f ? v * job->leak : v;
        }
}

// Instance norm in place: each channel of each image gets mean 0 and deviation 1; then ReLU, if `rectify` is set.
static gsf_result gsf__amt_norm(gsf__amt* net, int rectify, const gsf__map* y) {
    const size_t count = (size_t)(y->images * y->channels);
    double* moments = (double*)gsf_alloc(net->ctx, count, 2 * sizeof(double));
    gsf__amt_row_job job;
    if (!moments) return GSF_ERROR_OUT_OF_MEMORY;
    memset(&job, 0, sizeof job);
    job.y = y;
    job.moments = moments;
    job.leak = rectify ? 0.0f : 1.0f;
    gsf__parallel_for(net->ctx, count, gsf__amt_sum_channel, &job);
    gsf__parallel_for(net->ctx, (size_t)(y->images * y->height), gsf__amt_norm_row, &job);
    gsf_free(net->ctx, moments);
    return gsf__check_cancel(net->ctx);
}

// ---- AMT-S: layers

// A new map y = conv(x), with its PReLU if it has one.
static gsf_result gsf__amt_convolve(gsf__amt* net, const gsf__amt_conv* layer, int64_t stride, const gsf__map* x,
                                    gsf__map* y) {
    const int64_t pad = layer->conv.weight->shape[2] / 2, over = 2 * pad - layer->conv.weight->shape[2];
    GSF__TRY(gsf__amt_make(net, x->images, (x->height + over) / stride + 1, (x->width + over) / stride + 1,
                           layer->conv.weight->shape[0], y));
    GSF__TRY(gsf__map_convolve(net->ctx, &net->conv, &layer->conv, stride, pad, 0, x, y));
    return layer->slope ? gsf__amt_activate(net, layer->slope, 0.0f, y) : GSF_OK;
}

// The same in place or into an existing map, at stride 1; `leak` is the slope of a LeakyReLU, 1: none
static gsf_result gsf__amt_convolve_to(gsf__amt* net, const gsf__nn_layer* layer, float leak, const gsf__map* x,
                                       const gsf__map* y) {
    GSF__TRY(gsf__map_convolve(net->ctx, &net->conv, layer, 1, layer->weight->shape[2] / 2, 0, x, y));
    return leak != 1.0f ? gsf__amt_activate(net, NULL, leak, y) : GSF_OK;
}

// ConvTranspose2d(4, stride 2, padding 1): for each parity of the output's row and column a 2 x 2 convolution.
static gsf_result gsf__amt_up(gsf__amt* net, const gsf__nn_layer* layer, const gsf__map* x, const gsf__map* y) {
    const int64_t in = layer->weight->shape[0], out = layer->weight->shape[1], shape[4] = {out, in, 2, 2};
    float* parts = (float*)gsf_alloc(net->ctx, (size_t)(16 * in * out), 2 * sizeof(float));
    gsf_result result = parts ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (!result) gsf_nn_convert_tensor(layer->weight, 0, 16 * in * out, parts + 16 * in * out);
    for (int64_t parity = 0; parity < 4 && !result; parity++) {
        const int64_t py = parity / 2, px = parity % 2;
        float* w = parts + parity * 4 * in * out;
        for (int64_t o = 0; o < out; o++)
            for (int64_t i = 0; i < in; i++)
                for (int64_t k = 0; k < 4; k++) // rows before and at the output's (parity 0), or at and after it
                    w[(o * in + i) * 4 + k] = parts[16 * in * out + (i * out + o) * 16 + (3 - py - 2 * (k / 2)) * 4 +
                                                    (3 - px - 2 * (k % 2))];
        const gsf_nn_tensor weight = gsf_nn_wrap_tensor(layer->weight->name, w, 4, shape);
        const gsf__nn_layer quarter = {&weight, layer->bias};
        gsf__map part = *y;
        part.data += (py * y->width + px) * y->pitch;
        part.height = x->height;
        part.width = x->width;
        const gsf__map_conv c = {&quarter, 1, 1, 0, 1 - py, px, 2 * y->pitch, 2 * y->width * y->pitch};
        result = gsf__map_convolve_at(net->ctx, &net->conv, &c, x, &part);
    }
    gsf_free(net->ctx, parts);
    return result ? result : gsf__check_cancel(net->ctx);
}

static gsf_result gsf__amt_bottleneck_run(gsf__amt* net, const gsf__amt_bottleneck* b, int64_t stride, const gsf__map* x,
                                          gsf__map* out) {
    gsf__map a, c, d;
    GSF__TRY(gsf__amt_convolve(net, &b->convs[0], 1, x, &a));
    GSF__TRY(gsf__amt_norm(net, 1, &a));
    GSF__TRY(gsf__amt_convolve(net, &b->convs[1], stride, &a, &c));
    GSF__TRY(gsf__amt_norm(net, 1, &c));
    GSF__TRY(gsf__amt_convolve(net, &b->convs[2], 1, &c, out));
    GSF__TRY(gsf__amt_norm(net, 1, out));
    if (b->down.conv.weight) {
        GSF__TRY(gsf__amt_convolve(net, &b->down, stride, x, &d));
        GSF__TRY(gsf__amt_norm(net, 0, &d));
    }
    gsf__amt_add(net, b->down.conv.weight ? &d : x, out);
    return gsf__amt_activate(net, NULL, 0.0f, out);
}

// Concatenated input -> flows (4 channels) and what follows them, at twice the size; y has been made.
static gsf_result gsf__amt_decode(gsf__amt* net, const gsf__amt_decoder* d, const gsf__map* x, const gsf__map* y) {
    gsf__map a, b, c;
    GSF__TRY(gsf__amt_convolve(net, &d->first, 1, x, &a));
    GSF__TRY(gsf__amt_convolve(net, &d->convs[0], 1, &a, &b));
    for (int i = 1; i <= 3; i++) { // 1, 3: the last channels only, in place; 2: all
        const int64_t side = d->convs[i].conv.weight->shape[0];
        const gsf__map part = gsf__map_slice(&b, b.channels - side, side);
        if (i == 2) {
            GSF__TRY(gsf__amt_convolve(net, &d->convs[2], 1, &b, &c));
            b = c;
            continue;
        }
        GSF__TRY(gsf__map_convolve(net->ctx, &net->conv, &d->convs[i].conv, 1, 1, 0, &part, &part));
        GSF__TRY(gsf__amt_activate(net, d->convs[i].slope, 0.0f, &part));
    }
    GSF__TRY(gsf__amt_make(net, 1, b.height, b.width, b.channels, &c));
    GSF__TRY(gsf__map_convolve(net->ctx, &net->conv, &d->convs[4].conv, 1, 1, 0, &b, &c));
    gsf__amt_add(net, &a, &c);
    GSF__TRY(gsf__amt_activate(net, d->convs[4].slope, 0.0f, &c));
    return gsf__amt_up(net, &d->up, &c, y);
}

// ---- AMT-S: correlation

typedef struct gsf__amt_lookup_job {
    const gsf__map* from;                    // features of one image, 1/8
    const gsf__map* pyramid;                 // (levels) of the other's
    const gsf__map *flow, *out;              // (flow: 2 channels, in 1/8 pixels; out: levels * 49)
} gsf__amt_lookup_job;

static float gsf__amt_dot(const float* a, const float* b, int64_t count) {
    float sums[8] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    int64_t i = 0;
    for (; i + 8 <= count; i += 8)
        for (int k = 0; k < 8; k++) sums[k] += a[i + k] * b[i + k];
    for (; i < count; i++) sums[i & 7] += a[i] * b[i];
    return ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]));
}

static void gsf__amt_lookup_row(void* arg, size_t row, int32_t worker) {
    enum { SIDE = GSF__AMT_WINDOW + 1 };
    const gsf__amt_lookup_job* job = (const gsf__amt_lookup_job*)arg;
    const int64_t channels = job->from->channels;
    const float *from = gsf__map_row(job->from, row), *flow = gsf__map_row(job->flow, row);
    const float scale = (float)(1.0 / sqrt((double)channels));
    float* out = gsf__map_row(job->out, row);
    (void)worker;
    for (int64_t x = 0; x < job->from->width; x++, from += job->from->pitch, flow += job->flow->pitch, out += job->out->pitch)
        for (int level = 0; level < GSF__AMT_LEVELS; level++) {
            const gsf__map* to = &job->pyramid[level];
            const double by = 1.0 / (double)(1 << level);
            double u = ((double)x + 2.0 * (double)flow[0]) * by, v = ((double)row + 2.0 * (double)flow[1]) * by;
            float products[SIDE][SIDE];
            if (!(fabs(u) < 1e6)) u = 1e6; // outside, as is a NaN
            if (!(fabs(v) < 1e6)) v = 1e6;
            const int64_t u0 = (int64_t)floor(u) - GSF__AMT_RADIUS, v0 = (int64_t)floor(v) - GSF__AMT_RADIUS;
            const float du = (float)(u - floor(u)), dv = (float)(v - floor(v));
            for (int64_t j = 0; j < SIDE; j++)
                for (int64_t i = 0; i < SIDE; i++) {
                    const int inside = u0 + i >= 0 && u0 + i < to->width && v0 + j >= 0 && v0 + j < to->height;
                    const float* at = inside ? to->data + ((v0 + j) * to->width + u0 + i) * to->pitch : NULL;
                    products[j][i] = at ? scale * gsf__amt_dot(from, at, channels) : 0.0f;
                }
            float* window = out + level * GSF__AMT_WINDOW * GSF__AMT_WINDOW;
            for (int64_t i = 0; i < GSF__AMT_WINDOW; i++) // the offset in x varies slowest
                for (int64_t j = 0; j < GSF__AMT_WINDOW; j++) {
                    const float top = products[j][i] + (products[j][i + 1] - products[j][i]) * du;
                    const float bottom = products[j + 1][i] + (products[j + 1][i + 1] - products[j + 1][i]) * du;
                    window[i * GSF__AMT_WINDOW + j] = top + (bottom - top) * dv;
                }
        }
}

static void gsf__amt_pool_row(void* arg, size_t row, int32_t worker) { // means of 2 x 2
    const gsf__amt_row_job* job = (const gsf__amt_row_job*)arg;
    const float *a = gsf__map_row(job->x, 2 * row), *b = gsf__map_row(job->x, 2 * row + 1);
    float* y = gsf__map_row(job->y, row);
    const int64_t c = job->y->channels;
    (void)worker;
    for (int64_t x = 0; x < job->y->width; x++, a += 2 * c, b += 2 * c, y += c)
        for (int64_t i = 0; i < c; i++) y[i] = 0.25f * ((a[i] + a[c + i]) + (b[i] + b[c + i]));
}

static gsf_result gsf__amt_make_pyramid(gsf__amt* net, const gsf__map* features, gsf__map* pyramid) {
    pyramid[0] = *features;
    for (int i = 1; i < GSF__AMT_LEVELS; i++) {
        gsf__amt_row_job job;
        memset(&job, 0, sizeof job);
        job.x = &pyramid[i - 1];
        job.y = &pyramid[i];
        GSF__TRY(gsf__amt_make(net, 1, job.x->height / 2, job.x->width / 2, job.x->channels, &pyramid[i]));
        gsf__parallel_for(net->ctx, (size_t)pyramid[i].height, gsf__amt_pool_row, &job);
    }
    return GSF_OK;
}

// ---- AMT-S: the network

typedef struct gsf__amt_pair { // of an interpolation
    gsf__map images;                            // both, padded, less their mean
    double mean;
    gsf__map pyramids[2][GSF__AMT_LEVELS];      // features to correlate, of either image
    gsf__map features[GSF__AMT_SCALES];         // of both images, from 1/2 to 1/16
} gsf__amt_pair;

static void gsf__amt_reveal(const gsf__amt* net, const char* name, int level, const gsf__map* map) {
    if (!net->tap) return;
    for (int64_t i = 0; i < map->images; i++) { // pixel by pixel, as slices are not dense; `rows` is the pixel's number
        const gsf__map image = gsf__map_image(map, i);
        for (int64_t k = 0; k < map->height * map->width; k++)
            net->tap->fn(net->tap->user, name, (int32_t)(level * 2 + i), image.data + k * map->pitch, k, map->channels);
    }
}

static gsf_result gsf__amt_encode(gsf__amt* net, gsf__amt_pair* pair) {
    gsf__map x, y;
    GSF__TRY(gsf__amt_convolve(net, &net->stem, 2, &pair->images, &x));
    GSF__TRY(gsf__amt_norm(net, 1, &x));
    for (int i = 0; i < 6; i++, x = y)
        GSF__TRY(gsf__amt_bottleneck_run(net, &net->bottlenecks[i], i == 2 || i == 4 ? 2 : 1, &x, &y));
    GSF__TRY(gsf__amt_convolve(net, &net->head, 1, &x, &y));
    gsf__amt_reveal(net, "feat_encoder", 0, &y);
    for (int i = 0; i < 2; i++) {
        const gsf__map image = gsf__map_image(&y, i);
        GSF__TRY(gsf__amt_make_pyramid(net, &image, pair->pyramids[i]));
    }
    x = pair->images;
    for (int i = 0; i < GSF__AMT_SCALES; i++, x = pair->features[i - 1]) {
        GSF__TRY(gsf__amt_convolve(net, &net->pyramid[i][0], 2, &x, &y));
        GSF__TRY(gsf__amt_convolve(net, &net->pyramid[i][1], 1, &y, &pair->features[i]));
        gsf__amt_reveal(net, "pyramid", i, &pair->features[i]);
    }
    return GSF_OK;
}

// Adds the update to decoded flows (4 channels) and features, at 1/`down` of the correlations' scale.
static gsf_result gsf__amt_update_run(gsf__amt* net, int scale, const gsf__amt_pair* pair, const gsf__map* decoded) {
    const gsf__amt_update* u = &net->updates[scale];
    const gsf__map flows = gsf__map_slice(decoded, 0, 4), features = gsf__map_slice(decoded, 4, decoded->channels - 4);
    const int64_t high = pair->pyramids[0][0].height, wide = pair->pyramids[0][0].width;
    const double down = (double)(1 << (3 - scale));
    const int64_t of_c = u->c1.weight->shape[0], of_f = u->f2.weight->shape[0], of_m = u->conv.weight->shape[0];
    gsf__map corr, mix, flow1, input, hidden[2], small, delta;
    const int room = net->room;
    GSF__TRY(gsf__amt_make(net, 1, high, wide, 2 * GSF__AMT_LOOKUP, &corr));
    GSF__TRY(gsf__amt_make(net, 1, high, wide, of_c + of_f, &mix));
    GSF__TRY(gsf__amt_make(net, 1, high, wide, of_m + 4 + features.channels, &input)); // motion, flows, features
    const gsf__map flow = gsf__map_slice(&input, of_m, 4), kept = gsf__map_slice(&input, of_m + 4, features.channels);
    gsf__amt_resize(net, &flows, 1.0 / down, 1.0 / down, &flow);
    gsf__amt_resize(net, &features, 1.0 / down, 1.0, &kept);
    for (int i = 0; i < 2; i++) { // the middle's flow to the second image, doubled, leads from the first to it
        const gsf__map way = gsf__map_slice(&flow, 2 * !i, 2);
        const gsf__map out = gsf__map_slice(&corr, i * GSF__AMT_LOOKUP, GSF__AMT_LOOKUP);
        gsf__amt_lookup_job job = {&pair->pyramids[i][0], pair->pyramids[!i], &way, &out};
        gsf__parallel_for(net->ctx, (size_t)high, gsf__amt_lookup_row, &job);
    }
    gsf__amt_reveal(net, "update.in_flow", scale, &flow);
    gsf__amt_reveal(net, "update.corr", scale, &corr);
    const gsf__map mixed_c = gsf__map_slice(&mix, 0, of_c), mixed_f = gsf__map_slice(&mix, of_c, of_f);
    const gsf__map motion = gsf__map_slice(&input, 0, of_m);
    GSF__TRY(gsf__amt_convolve_to(net, &u->c1, 0.1f, &corr, &mixed_c));
    GSF__TRY(gsf__amt_make(net, 1, high, wide, u->f1.weight->shape[0], &flow1));
    GSF__TRY(gsf__amt_convolve_to(net, &u->f1, 0.1f, &flow, &flow1));
    GSF__TRY(gsf__amt_convolve_to(net, &u->f2, 0.1f, &flow1, &mixed_f));
    GSF__TRY(gsf__amt_convolve_to(net, &u->conv, 0.1f, &mix, &motion));
    for (int i = 0; i < 2; i++) {
        GSF__TRY(gsf__amt_make(net, 1, high, wide, u->gru[i].weight->shape[0], &hidden[i]));
        GSF__TRY(gsf__amt_convolve_to(net, &u->gru[i], i ? 1.0f : 0.1f, i ? &hidden[0] : &input, &hidden[i]));
    }
    for (int i = 0; i < 2; i++) { // flows, features
        const gsf__nn_layer* head = i ? u->feature : u->flow;
        const gsf__map* to = i ? &features : &flows;
        const char* const names[2] = {"update.out1", "update.out0"};
        GSF__TRY(gsf__amt_make(net, 1, high, wide, head[0].weight->shape[0], &hidden[0]));
        GSF__TRY(gsf__amt_convolve_to(net, &head[0], 0.1f, &hidden[1], &hidden[0]));
        GSF__TRY(gsf__amt_make(net, 1, high, wide, to->channels, &small));
        GSF__TRY(gsf__amt_convolve_to(net, &head[1], 1.0f, &hidden[0], &small));
        GSF__TRY(gsf__amt_make(net, 1, to->height, to->width, to->channels, &delta));
        gsf__amt_resize(net, &small, down, i ? 1.0 : down, &delta);
        gsf__amt_reveal(net, names[i], scale, &delta);
        gsf__amt_add(net, &delta, to);
    }
    net->room = room;
    return GSF_OK;
}

// decoded (flows, features) at a scale -> at the next finer one; scale 3: there is none before
static gsf_result gsf__amt_refine(gsf__amt* net, int scale, const gsf__amt_pair* pair, const gsf__map* before,
                                  gsf__map* decoded) {
    const gsf__map* f = &pair->features[scale];
    const int64_t c = f->channels, high = f->height, wide = f->width, kept = before ? before->channels - 4 : 0;
    gsf__map input, coarse;
    GSF__TRY(gsf__amt_make(net, 1, 2 * high, 2 * wide, net->decoders[scale].up.weight->shape[1], decoded));
    const int room = net->room;
    GSF__TRY(gsf__amt_make(net, 1, high, wide, before ? kept + 2 * c + 4 : 2 * c + 1, &input));
    for (int i = 0; i < 2; i++) {
        const gsf__map image = gsf__map_image(f, i), to = gsf__map_slice(&input, kept + i * c, c);
        if (!before) {
            gsf__amt_copy(net, &image, &to);
        } else {
            const gsf__map flow = gsf__map_slice(before, 2 * i, 2);
            gsf__amt_warp(net, &image, &flow, &to);
        }
    }
    if (before) {
        const gsf__map features = gsf__map_slice(before, 4, kept), flows = gsf__map_slice(before, 0, 4);
        const gsf__map to = gsf__map_slice(&input, 0, kept), to_flows = gsf__map_slice(&input, kept + 2 * c, 4);
        gsf__amt_copy(net, &features, &to);
        gsf__amt_copy(net, &flows, &to_flows);
    } else {
        for (int64_t i = 0; i < high * wide; i++) input.data[i * input.pitch + 2 * c] = 0.5f; // the time in the middle
    }
    GSF__TRY(gsf__amt_decode(net, &net->decoders[scale], &input, decoded));
    if (before) {
        const gsf__map flows = gsf__map_slice(before, 0, 4);
        GSF__TRY(gsf__amt_make(net, 1, 2 * high, 2 * wide, 4, &coarse));
        gsf__amt_resize(net, &flows, 2.0, 2.0, &coarse);
        for (int i = 0; i < 2 && scale == 0; i++) // each of the candidates' flows, all to the first image, then the second
            for (int k = 0; k < GSF__AMT_FLOWS; k++) {
                const gsf__map from = gsf__map_slice(&coarse, 2 * i, 2);
                const gsf__map to = gsf__map_slice(decoded, 2 * (i * GSF__AMT_FLOWS + k), 2);
                gsf__amt_add(net, &from, &to);
            }
        const gsf__map to = gsf__map_slice(decoded, 0, 4);
        if (scale > 0) gsf__amt_add(net, &coarse, &to);
    }
    gsf__amt_reveal(net, "decoder", scale, decoded);
    net->room = room;
    return GSF_OK;
}

typedef struct gsf__amt_merge_job {
    const gsf__map *images, *decoded, *candidates;
    double mean;
} gsf__amt_merge_job;

// Candidates: both images along the flows, mixed by a mask, plus a residual.
static void gsf__amt_merge_row(void* arg, size_t row, int32_t worker) {
    const gsf__amt_merge_job* job = (const gsf__amt_merge_job*)arg;
    const gsf__map image[2] = {gsf__map_image(job->images, 0), gsf__map_image(job->images, 1)};
    const float* d = gsf__map_row(job->decoded, row);
    float* y = gsf__map_row(job->candidates, row);
    (void)worker;
    for (int64_t x = 0; x < job->images->width; x++, d += job->decoded->pitch, y += job->candidates->pitch)
        for (int k = 0; k < GSF__AMT_FLOWS; k++) {
            float warped[2][3];
            const double mask = 1.0 / (1.0 + exp(-(double)d[4 * GSF__AMT_FLOWS + k]));
            for (int i = 0; i < 2; i++) {
                const float* flow = d + 2 * (i * GSF__AMT_FLOWS + k);
                gsf__map_sample(&image[i], gsf__look_between((double)row + (double)flow[1], image[i].height),
                                gsf__look_between((double)x + (double)flow[0], image[i].width), 1.0f, 3, warped[i]);
            }
            for (int c = 0; c < 3; c++)
                y[3 * k + c] = (float)(mask * (double)warped[0][c] + (1.0 - mask) * (double)warped[1][c] + job->mean +
                                       (double)d[5 * GSF__AMT_FLOWS + 3 * k + c]);
        }
}

// The frame between the pair's, unclamped: (padded height, padded width, 3)
static gsf_result gsf__amt_interpolate(gsf__amt* net, gsf__amt_pair* pair, gsf__map* out) {
    gsf__map decoded, finer, candidates, hidden;
    GSF__TRY(gsf__amt_encode(net, pair));
    for (int scale = GSF__AMT_SCALES - 1; scale >= 0; scale--, decoded = finer) {
        GSF__TRY(gsf__amt_refine(net, scale, pair, scale == GSF__AMT_SCALES - 1 ? NULL : &decoded, &finer));
        if (scale > 0) GSF__TRY(gsf__amt_update_run(net, scale, pair, &finer));
    }
    GSF__TRY(gsf__amt_make(net, 1, pair->images.height, pair->images.width, 3 * GSF__AMT_FLOWS, &candidates));
    gsf__amt_merge_job job = {&pair->images, &decoded, &candidates, pair->mean};
    gsf__parallel_for(net->ctx, (size_t)candidates.height, gsf__amt_merge_row, &job);
    GSF__TRY(gsf__amt_convolve(net, &net->merge[0], 1, &candidates, &hidden));
    GSF__TRY(gsf__amt_convolve(net, &net->merge[1], 1, &hidden, out));
    for (int64_t i = 0; i < out->height * out->width; i++)
        for (int c = 0; c < 3; c++) {
            const float* y = candidates.data + i * candidates.pitch + c;
            out->data[3 * i + c] += (float)(((double)y[0] + (double)y[3] + (double)y[6]) / (double)GSF__AMT_FLOWS);
        }
    return GSF_OK;
}

// Pads both images (u8) to multiples of 16 by repeating their borders, and removes their common mean.
static gsf_result gsf__amt_pad(gsf__amt* net, const gsf_image* a, const gsf_image* b, gsf__amt_pair* pair) {
    const int64_t wide = gsf__round_up(a->width, GSF__AMT_STEP), high = gsf__round_up(a->height, GSF__AMT_STEP);
    const int64_t left = (wide - a->width) / 2, top = (high - a->height) / 2;
    uint64_t sum = 0;
    if (wide < GSF__AMT_LEAST || high < GSF__AMT_LEAST)
        return gsf_fail(net->ctx, GSF_ERROR_DEGENERATE, "motion smoothness: frames of %lld x %lld are below %d pixels",
                        (long long)a->width, (long long)a->height, (int)GSF__AMT_LEAST);
    GSF__TRY(gsf__amt_make(net, 2, high, wide, 3, &pair->images));
    for (int pass = 0; pass < 2; pass++) {
        float* out = pair->images.data;
        for (int k = 0; k < 2; k++)
            for (int64_t y = 0; y < high; y++)
                for (int64_t x = 0; x < wide; x++) {
                    const gsf_image* image = k ? b : a;
                    const int64_t v = y < top ? 0 : gsf__least(y - top, a->height - 1);
                    const int64_t u = x < left ? 0 : gsf__least(x - left, a->width - 1);
                    const uint8_t* at = (const uint8_t*)image->data + v * image->stride_y + u * image->stride_x;
                    for (int c = 0; c < 3; c++) {
                        if (pass) *out++ = (float)(at[c] / 255.0 - pair->mean);
                        else sum += at[c];
                    }
                }
        pair->mean = (double)sum / 255.0 / (6.0 * (double)wide * (double)high);
    }
    return GSF_OK;
}

// ---- AMT-S: opening it

static gsf_result gsf__amt_need(gsf__nn_loader* loader, gsf__nn_layer* out, int64_t in, int64_t kernel, const char* name) {
    const int64_t shape[4] = {-1, in, kernel, kernel};
    GSF__TRY(gsf__nn_need(loader, &out->weight, 4, shape, "%s.weight", name));
    if (out->weight->shape[0] < 1)
        return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensor %s is empty", loader->weights->name, out->weight->name);
    return gsf__nn_need(loader, &out->bias, 1, out->weight->shape, "%s.bias", name);
}

// NAME.0 and its PReLU NAME.1
static gsf_result gsf__amt_need_prelu(gsf__nn_loader* loader, gsf__amt_conv* out, int64_t in, const char* name) {
    char conv[96];
    snprintf(conv, sizeof conv, "%.93s.0", name);
    GSF__TRY(gsf__amt_need(loader, &out->conv, in, 3, conv));
    return gsf__nn_need(loader, &out->slope, 1, out->conv.weight->shape, "%s.1.weight", name);
}

static gsf_result gsf__amt_wrong(const gsf__nn_loader* loader, const gsf_nn_tensor* tensor) {
    return gsf_fail(loader->ctx, GSF_ERROR_FORMAT, "%s: tensor %s does not fit the layers around it", loader->weights->name,
                    tensor->name);
}

static gsf_result gsf__amt_bind_decoder(gsf__nn_loader* loader, int scale, int64_t in, int64_t out, gsf__amt_decoder* d) {
    char name[96];
    snprintf(name, sizeof name, "decoder%d.convblock.0", scale + 1);
    GSF__TRY(gsf__amt_need_prelu(loader, &d->first, in, name));
    const int64_t width = d->first.conv.weight->shape[0], up[4] = {width, out, 4, 4};
    int64_t side = 0;
    for (int i = 0; i < 4; i++) {
        snprintf(name, sizeof name, "decoder%d.convblock.1.conv%d", scale + 1, i + 1);
        GSF__TRY(gsf__amt_need_prelu(loader, &d->convs[i], i % 2 == 0 ? width : i == 1 ? -1 : side, name));
        const int64_t channels = d->convs[i].conv.weight->shape[0];
        if (i == 1) side = channels;
        if (channels != (i % 2 == 0 ? width : side) || d->convs[i].conv.weight->shape[1] != channels || side > width)
            return gsf__amt_wrong(loader, d->convs[i].conv.weight);
    }
    snprintf(name, sizeof name, "decoder%d.convblock.1.conv5", scale + 1);
    GSF__TRY(gsf__amt_need(loader, &d->convs[4].conv, width, 3, name));
    if (d->convs[4].conv.weight->shape[0] != width) return gsf__amt_wrong(loader, d->convs[4].conv.weight);
    GSF__TRY(gsf__nn_need(loader, &d->convs[4].slope, 1, d->convs[4].conv.weight->shape, "decoder%d.convblock.1.prelu.weight",
                          scale + 1));
    GSF__TRY(gsf__nn_need(loader, &d->up.weight, 4, up, "decoder%d.convblock.2.weight", scale + 1));
    return gsf__nn_need(loader, &d->up.bias, 1, up + 1, "decoder%d.convblock.2.bias", scale + 1);
}

static gsf_result gsf__amt_bind_update(gsf__nn_loader* loader, int scale, int64_t features, gsf__amt_update* u) {
    struct { gsf__nn_layer* layer; int64_t in, kernel, out; const char* name; } parts[10] = {
        {&u->c1, 2 * GSF__AMT_LOOKUP, 1, -1, "convc1"}, {&u->f1, 4, 7, -1, "convf1"}, {&u->f2, -1, 3, -1, "convf2"},
        {&u->conv, -1, 3, -1, "conv"}, {&u->gru[0], -1, 3, -1, "gru.0"}, {&u->gru[1], -1, 3, -1, "gru.2"},
        {&u->feature[0], -1, 3, -1, "feat_head.0"}, {&u->feature[1], -1, 3, features, "feat_head.2"},
        {&u->flow[0], -1, 3, -1, "flow_head.0"}, {&u->flow[1], -1, 3, 4, "flow_head.2"},
    };
    for (int i = 0; i < 10; i++) {
        char name[64];
        int64_t in = parts[i].in;
        if (i == 3) in = u->c1.weight->shape[0] + u->f2.weight->shape[0];
        else if (i == 4) in = u->conv.weight->shape[0] + 4 + features;
        else if (i == 6 || i == 8) in = u->gru[1].weight->shape[0];
        else if (i > 1) in = parts[i - 1].layer->weight->shape[0];
        snprintf(name, sizeof name, "update%d.%s", scale + 1, parts[i].name);
        GSF__TRY(gsf__amt_need(loader, parts[i].layer, in, parts[i].kernel, name));
        if (parts[i].out >= 0 && parts[i].layer->weight->shape[0] != parts[i].out)
            return gsf__amt_wrong(loader, parts[i].layer->weight);
    }
    return GSF_OK;
}

static gsf_result gsf__amt_bind_features(gsf__nn_loader* loader, gsf__amt* net) {
    char name[96];
    GSF__TRY(gsf__amt_need(loader, &net->stem.conv, 3, 7, "feat_encoder.conv1"));
    int64_t channels = net->stem.conv.weight->shape[0];
    for (int i = 0; i < 6; i++) {
        gsf__amt_bottleneck* b = &net->bottlenecks[i];
        int64_t in = channels;
        for (int k = 0; k < 3; k++) {
            snprintf(name, sizeof name, "feat_encoder.layer%d.%d.conv%d", i / 2 + 1, i % 2, k + 1);
            GSF__TRY(gsf__amt_need(loader, &b->convs[k].conv, in, k == 1 ? 3 : 1, name));
            in = b->convs[k].conv.weight->shape[0];
        }
        snprintf(name, sizeof name, "feat_encoder.layer%d.0.downsample.0", i / 2 + 1);
        if (i == 2 || i == 4) GSF__TRY(gsf__amt_need(loader, &b->down.conv, channels, 1, name));
        if ((b->down.conv.weight ? b->down.conv.weight->shape[0] : channels) != in)
            return gsf__amt_wrong(loader, b->convs[2].conv.weight);
        channels = in;
    }
    return gsf__amt_need(loader, &net->head.conv, channels, 1, "feat_encoder.conv2");
}

static gsf_result gsf__amt_bind(gsf__nn_loader* loader, gsf__amt* net) {
    int64_t channels[GSF__AMT_SCALES], in = 3;
    char name[96];
    GSF__TRY(gsf__amt_bind_features(loader, net));
    for (int i = 0; i < GSF__AMT_SCALES; i++)
        for (int k = 0; k < 2; k++) {
            snprintf(name, sizeof name, "encoder.pyramid%d.%d", i + 1, k);
            GSF__TRY(gsf__amt_need_prelu(loader, &net->pyramid[i][k], in, name));
            in = channels[i] = net->pyramid[i][k].conv.weight->shape[0];
        }
    for (int i = GSF__AMT_SCALES - 1; i >= 0; i--) {
        const int64_t wide = i == GSF__AMT_SCALES - 1 ? 2 * channels[i] + 1 : 3 * channels[i] + 4;
        GSF__TRY(gsf__amt_bind_decoder(loader, i, wide, i ? channels[i - 1] + 4 : 8 * GSF__AMT_FLOWS, &net->decoders[i]));
        if (i) GSF__TRY(gsf__amt_bind_update(loader, i, channels[i - 1], &net->updates[i]));
    }
    GSF__TRY(gsf__amt_need_prelu(loader, &net->merge[0], 3 * GSF__AMT_FLOWS, "comb_block"));
    GSF__TRY(gsf__amt_need(loader, &net->merge[1].conv, net->merge[0].conv.weight->shape[0], 3, "comb_block.2"));
    return net->merge[1].conv.weight->shape[0] == 3 ? GSF_OK : gsf__amt_wrong(loader, net->merge[1].conv.weight);
}

static gsf_result gsf__amt_open(gsf_context* ctx, const gsf_nn_metric* metric, void* state) {
    gsf__amt* net = (gsf__amt*)state;
    gsf__nn_loader loader;
    GSF__TRY(gsf_nn_load_weights(ctx, metric->models, "amt-s", &net->weights));
    GSF__TRY(gsf__nn_begin_loading(ctx, &net->weights, &loader));
    return gsf__nn_end_loading(&loader, gsf__amt_bind(&loader, net));
}

static void gsf__amt_close(gsf_context* ctx, void* state) {
    gsf__amt* net = (gsf__amt*)state;
    for (int i = 0; i < GSF__AMT_ROOMS; i++) gsf__nn_destroy_workspace(ctx, &net->rooms[i]);
    gsf__nn_destroy_workspace(ctx, &net->conv);
    gsf_destroy_image(ctx, &net->even);
    gsf_destroy_image(ctx, &net->odd);
    gsf_destroy_image(ctx, &net->middle);
    gsf_nn_destroy_weights(ctx, &net->weights);
}

// ---- metrics: motion smoothness (VBench)

// Every second frame is compared with the one that AMT-S puts between its neighbours: the score is 1 less the mean absolute
// difference of 8-bit values (interpolated ones are cut off, not rounded), over 255.

// The frame between two (u8, packed) of one size, u8.
static gsf_result gsf__amt_middle(gsf_context* ctx, gsf__amt* net, const gsf_image* a, const gsf_image* b, gsf_image* out) {
    gsf__amt_pair pair;
    gsf__map middle;
    memset(&pair, 0, sizeof pair);
    net->ctx = ctx;
    net->room = 0;
    GSF__TRY(gsf__amt_pad(net, a, b, &pair));
    GSF__TRY(gsf__amt_interpolate(net, &pair, &middle));
    gsf__amt_reveal(net, "middle", 0, &middle);
    const int64_t left = (middle.width - a->width) / 2, top = (middle.height - a->height) / 2;
    uint8_t* to = (uint8_t*)out->data;
    for (int64_t y = 0; y < a->height; y++)
        for (int64_t i = 0; i < a->width * 3; i++) {
            const float v = 255.0f * middle.data[((y + top) * middle.width + left) * 3 + i];
            if (v != v) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s: the interpolated frame is not finite", net->weights.name);
            *to++ = (uint8_t)(v > 0.0f ? (v < 255.0f ? v : 255.0f) : 0.0f);
        }
    return GSF_OK;
}

static gsf_result gsf__amt_measure(gsf_context* ctx, gsf_nn_metric* metric, const gsf_image* frame,
                                   const gsf_image* reference) {
    gsf__amt* net = (gsf__amt*)metric->state;
    const int64_t w = frame->width, h = frame->height;
    (void)reference;
    net->tap = metric->_tap;
    if (!net->even.data) {
        GSF__TRY(gsf_make_image(ctx, GSF_U8, w, h, 3, &net->even));
        GSF__TRY(gsf_make_image(ctx, GSF_U8, w, h, 3, &net->odd));
        GSF__TRY(gsf_make_image(ctx, GSF_U8, w, h, 3, &net->middle));
    }
    if (w != net->even.width || h != net->even.height || !net->middle.data)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "motion smoothness: a frame of %lld x %lld after one of %lld x %lld",
                        (long long)w, (long long)h, (long long)net->even.width, (long long)net->even.height);
    if (net->frames % 2 || net->frames == 0) {
        GSF__TRY(gsf_convert_image(ctx, frame, net->frames ? &net->odd : &net->even));
    } else {
        gsf_image now;
        uint64_t sum = 0;
        const uint8_t *x = (const uint8_t*)net->middle.data, *y = (const uint8_t*)net->odd.data;
        memset(&now, 0, sizeof now);
        GSF__TRY(gsf_make_image(ctx, GSF_U8, w, h, 3, &now));
        gsf_result result = gsf_convert_image(ctx, frame, &now);
        if (!result) result = gsf__amt_middle(ctx, net, &net->even, &now, &net->middle);
        if (result) {
            gsf_destroy_image(ctx, &now);
            return result;
        }
        gsf_destroy_image(ctx, &net->even);
        net->even = now;
        for (int64_t i = 0; i < 3 * w * h; i++) sum += (uint64_t)(x[i] > y[i] ? x[i] - y[i] : y[i] - x[i]);
        metric->last = (double)sum / (3.0 * (double)w * (double)h);
        net->sum += metric->last;
        metric->score = 1.0 - net->sum / (double)(net->frames / 2) / 255.0;
    }
    metric->count = ++net->frames;
    return GSF_OK;
}

// ---- metrics: streams of frames

static gsf_result gsf__lpips_open_metric(gsf_context* ctx, const gsf_nn_metric* metric, void* state) {
    return gsf__lpips_open(ctx, metric->models, (int)metric->kind, (gsf__lpips*)state);
}

static const struct gsf__metric_form { // by kind
    size_t size; // of the state, which starts as zeros
    gsf_result (*open)(gsf_context* ctx, const gsf_nn_metric* metric, void* state);
    gsf_result (*measure)(gsf_context* ctx, gsf_nn_metric* metric, const gsf_image* frame, const gsf_image* reference);
    void (*close)(gsf_context* ctx, void* state); // also of a state that failed to open
} gsf__metric_forms[] = {
    {sizeof(gsf__lpips), gsf__lpips_open_metric, gsf__lpips_measure, gsf__lpips_close},
    {sizeof(gsf__lpips), gsf__lpips_open_metric, gsf__lpips_measure, gsf__lpips_close},
    {sizeof(gsf__lpips), gsf__lpips_open_metric, gsf__lpips_measure, gsf__lpips_close},
    {sizeof(gsf__i2v), gsf__i2v_open, gsf__i2v_measure, gsf__i2v_close},
    {sizeof(gsf__i2v), gsf__i2v_open, gsf__i2v_measure, gsf__i2v_close},
    {sizeof(gsf__amt), gsf__amt_open, gsf__amt_measure, gsf__amt_close},
};

static gsf_result gsf__metric_open(gsf_context* ctx, gsf_nn_metric* metric) {
    if (metric->state) return GSF_OK;
    if ((int)metric->kind < 0 || (size_t)metric->kind >= GSF__COUNT(gsf__metric_forms) || !metric->models)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "metric %d: no such kind, or no folder of models", (int)metric->kind);
    const struct gsf__metric_form* form = &gsf__metric_forms[metric->kind];
    metric->state = gsf_alloc_zeroed(ctx, 1, form->size);
    if (!metric->state) return GSF_ERROR_OUT_OF_MEMORY;
    const gsf_result result = form->open(ctx, metric, metric->state);
    if (result) {
        form->close(ctx, metric->state);
        gsf_free(ctx, metric->state);
        metric->state = NULL;
    }
    return result;
}

GSF_API gsf_result gsf_nn_measure_frame(gsf_context* ctx, gsf_nn_metric* metric, const gsf_image* frame,
                                        const gsf_image* reference) {
    GSF__TRY(gsf__metric_open(ctx, metric));
    if (!frame) return GSF_OK;
    for (int i = 0; i < 2; i++) {
        const gsf_image* image = i ? reference : frame;
        if (!image) continue;
        if (!image->data || image->width < 1 || image->height < 1 || image->channels != 3)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "metric: a %s of %lld x %lld with %d channels",
                            i ? "reference" : "frame", (long long)image->width, (long long)image->height,
                            (int)image->channels);
    }
    return gsf__metric_forms[metric->kind].measure(ctx, metric, frame, reference);
}

GSF_API void gsf_nn_destroy_metric(gsf_context* ctx, gsf_nn_metric* metric) {
    if (metric->state) gsf__metric_forms[metric->kind].close(ctx, metric->state);
    gsf_free(ctx, metric->state);
    memset(metric, 0, sizeof *metric);
}

// ---- >>nn training --------------------------------------------------------------

/* Only with GSF_NN_TRAINING. Gradients of a loss L: `dy` is dL/dy, `dx` is dL/dx. Gradients of weights are added to what
   is there; those of activations replace it unless `accumulate` is set. Sums over rows have a fixed order, so results do
   not depend on the number of workers. */
#ifdef GSF_NN_TRAINING

// ---- training: kernels

typedef struct gsf__grad_product { // c[r ldc + j] += sum of a[r a_row + k a_step] b[k ldb + j] over k < count
    const float *a, *b;
    float* c;
    int64_t a_row, a_step, ldb, ldc;
    int64_t rows, columns, count;
} gsf__grad_product;

typedef struct gsf__grad_job {
    const struct gsf__grad_kernels* kernels;
    const gsf__norm_kernels* norms;
    gsf__nn_activation activation;
    const float *x, *dy, *weight, *scale; // softmax: x is the forward pass's result
    const char* data;                     // the matrix to transpose
    gsf_nn_dtype dtype;
    float* dx;
    int64_t rows, columns, ld, chunk_rows;
    // adds row `row` to the sums per column; norms: products are of dy and the normalised x
    void (*add_row)(const struct gsf__grad_job* job, int64_t row, float* sums, float* products);
    double *sums, *products; // of each part of the rows; once done, the first part's are the totals
    float* short_sums;       // per worker, of a few rows: sums and products
    float eps, factor;
    int centre, accumulate;
} gsf__grad_job;

typedef struct gsf__adam_terms { // of one update; rest: 1 - beta; root: 1 / sqrt of the second moment's bias
    float scale, beta1, beta2, rest1, rest2, decay, rate, root, eps, average;
} gsf__adam_terms;

typedef struct gsf__grad_kernels {
    void (*multiply)(const gsf__grad_product* p);
    void (*activate)(gsf__nn_activation activation, const float* x, const float* dy, int64_t count, float* dx);
    void (*softmax)(const float* y, const float* dy, int64_t count, float scale, float* dx);
    void (*norm)(const gsf__grad_job* job, int64_t row, float* sums, float* products);
    void (*sum)(const gsf__grad_job* job, int64_t row, float* sums, float* products); // of dy, and of dy x unless x is NULL
    void (*scale)(const float* x, const float* y, int64_t count, float* out); // out = x y
    void (*add_product)(const float* x, const float* y, int64_t count, float* out); // out += x y
    // y = the sum of weight[k] * row at[k] of x or, with `add`, y += that; x (any, channels)
    void (*gather)(const int32_t* at, const float* weight, int64_t taps, const float* x, int64_t channels, int add, float* y);
    // Rotates pairs back: dx = dy turned by the negative angles; dx may be dy
    void (*rope)(const float* dy, int64_t count, const float* cos, const float* sin, float* dx);
    // sums[0] += sum of dy, sums[1] += sum of dy (x - mean) inverse
    void (*channel_sums)(const float* x, const float* dy, int64_t count, gsf__moments m, float inverse, double* sums);
    // dx = inverse (weight dy - mean - normalised x * slope); by: weight, mean, slope
    void (*channel)(const float* x, const float* dy, int64_t count, gsf__moments m, float inverse, const float* by, float* dx);
    // Updates m, v, value and, unless NULL, average; grad = 0
    void (*adam)(const gsf__adam_terms* terms, int64_t count, float* grad, float* m, float* v, float* value, float* average);
    // Turns logits into weights p = 2^(factor logit - lse) and dp into scale p (dp - delta)
    void (*attention)(float* logits, float* dp, int64_t count, float factor, float scale, float lse, float delta);
} gsf__grad_kernels;

static double gsf__nn_activation_slope(gsf__nn_activation activation, double x) {
    switch (activation) {
        case GSF__NN_LINEAR: return 1.0;
        case GSF__NN_GELU_TANH: {
            const double u = 0.7978845608028654 * (x + 0.044715 * x * x * x), s = 1.0 / (1.0 + exp(-2.0 * u));
            return s + 2.0 * x * s * (1.0 - s) * 0.7978845608028654 * (1.0 + 3.0 * 0.044715 * x * x);
        }
        case GSF__NN_SILU: {
            const double s = 1.0 / (1.0 + exp(-x));
            return s * (1.0 + x * (1.0 - s));
        }
        case GSF__NN_GELU:
            return 0.5 * erfc(-0.7071067811865476 * x) + x * exp(-0.5 * x * x) * 0.3989422804014327;
        case GSF__NN_RELU: return x > 0.0 ? 1.0 : 0.0;
        case GSF__NN_QUICK_GELU: return gsf__nn_activation_slope(GSF__NN_SILU, 1.702 * x);
    }
    return 1.0;
}

static void gsf__activate_grad_scalar(gsf__nn_activation activation, const float* x, const float* dy, int64_t count,
                                      float* dx) {
    for (int64_t i = 0; i < count; i++)
        dx[i] = (float)((double)dy[i] * gsf__nn_activation_slope(activation, (double)x[i]));
}

static void gsf__attention_grad_row_scalar(float* logits, float* dp, int64_t count, float factor, float scale, float lse,
                                           float delta) {
    for (int64_t j = 0; j < count; j++) {
        logits[j] = exp2f(factor * logits[j] - lse);
        dp[j] = scale * logits[j] * (dp[j] - delta);
    }
}

static void gsf__rope_grad_scalar(const float* dy, int64_t count, const float* cos, const float* sin, float* dx) {
    for (int64_t i = 0; i + 1 < count; i += 2) {
        const float a = dy[i], b = dy[i + 1];
        dx[i] = a * cos[i] + b * sin[i];
        dx[i + 1] = b * cos[i + 1] - a * sin[i + 1];
    }
    if (count % 2) dx[count - 1] = dy[count - 1];
}

#define gsf__v_slope GSF__V(gsf__v_slope)
#define gsf__norm_grad_terms GSF__V(gsf__norm_grad_terms)

#define GSF__KERNELS "gsfixer_nn.h"
#define GSF__KERNELS_GRADIENTS
#define GSF__KERNELS_AVX512
#include "gsfixer.h"
#undef GSF__KERNELS_GRADIENTS

#endif // GSF_NN_TRAINING
#endif // GSF__ISA
#ifdef GSF__KERNELS_GRADIENTS

// Up to 6 rows and 2 vectors of c. Missing rows repeat the last one. In loops over whole vectors `left` is a constant.
GSF__V_INLINE void GSF__V(gsf__multiply_tile)(const gsf__grad_product* p, int64_t row, int64_t column, size_t left) {
    const size_t left1 = left > GSF__LANES ? left - GSF__LANES : 0;
    const int64_t last = p->rows - row - 1, step = p->a_step;
    const float *a = p->a + row * p->a_row, *b = p->b + column;
    float* c = p->c + row * p->ldc + column;
#define GSF_X(r)                                            \
    const float* a##r = a + gsf__least(r, last) * p->a_row; \
    gsf__vf c##r = gsf__v_set(0.0f), d##r = c##r;
    GSF__SIX(GSF_X)
#undef GSF_X
    for (int64_t k = 0, at = 0; k < p->count; k++, at += step, b += p->ldb) {
        const gsf__vf b0 = gsf__v_load_first(b, left), b1 = gsf__v_load_first(b + GSF__LANES, left1);
        gsf__vf v;
#define GSF_X(r)                         \
        v = gsf__v_set(a##r[at]);        \
        c##r = gsf__v_madd(v, b0, c##r); \
        d##r = gsf__v_madd(v, b1, d##r);
        GSF__SIX(GSF_X)
#undef GSF_X
    }
#define GSF_X(r)                                                                                              \
    if (r <= last) {                                                                                          \
        float *to = c + (r) * p->ldc, *next = to + GSF__LANES;                                                \
        gsf__v_store_first(to, gsf__v_load_first(to, left) + c##r, left);                                     \
        if (left1) gsf__v_store_first(next, gsf__v_load_first(next, left1) + d##r, left1);                    \
    }
    GSF__SIX(GSF_X)
#undef GSF_X
}

GSF__V_KERNEL void GSF__V(gsf__multiply)(const gsf__grad_product* p) {
    for (int64_t j = 0; j < p->columns; j += 2 * GSF__LANES) {
        const size_t left = (size_t)(p->columns - j);
        for (int64_t r = 0; r < p->rows; r += 6) {
            if (left >= 2 * GSF__LANES) GSF__V(gsf__multiply_tile)(p, r, j, 2 * GSF__LANES);
            else GSF__V(gsf__multiply_tile)(p, r, j, left);
        }
    }
}

GSF__V_KERNEL void GSF__V(gsf__softmax_grad)(const float* y, const float* dy, int64_t count, float scale, float* dx) {
    gsf__vd total = gsf__vd_set(0.0);
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        total = gsf__vd_add_folded(total, gsf__v_load_first(y + i, left) * gsf__v_load_first(dy + i, left));
    }
    const gsf__vf sum = gsf__v_set((float)gsf__vd_sum(total)), factor = gsf__v_set(scale);
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf slope = gsf__v_load_first(dy + i, left) - sum;
        gsf__v_store_first(dx + i, factor * gsf__v_load_first(y + i, left) * slope, left);
    }
}

typedef struct gsf__norm_grad_terms { gsf__vf normal, d, h; } gsf__norm_grad_terms; // h: the gradient of `normal`

GSF__V_INLINE gsf__norm_grad_terms GSF__V(gsf__norm_grad_at)(const gsf__grad_job* job, const gsf__norm_terms* n,
                                                             const float* x, const float* dy, int64_t i) {
    const size_t left = (size_t)(job->columns - i);
    gsf__norm_grad_terms t;
    t.normal = gsf__norm_apply(n, gsf__v_load_first(x + i, left));
    t.h = t.d = gsf__v_load_first(dy + i, left);
    if (job->weight) t.h = t.h * gsf__v_load_first(job->weight + i, left);
    if (job->scale) t.h = gsf__v_madd(t.h, gsf__v_load_first(job->scale + i, left), t.h);
    return t;
}

GSF__V_KERNEL void GSF__V(gsf__norm_grad_row)(const gsf__grad_job* job, int64_t row, float* sums, float* products) {
    const int64_t dim = job->columns;
    const float *x = job->x + row * job->ld, *dy = job->dy + row * job->ld;
    float* dx = job->dx + row * job->ld;
    const gsf__moments m = job->norms->moments(x, dim, job->centre);
    const float inverse = gsf__norm_inverse(m, dim, job->eps);
    const gsf__norm_terms n = gsf__norm_terms_of(m, inverse);
    gsf__vd total = gsf__vd_set(0.0), weighted = total;
    for (int64_t i = 0; i < dim; i += GSF__LANES) {
        const size_t left = (size_t)(dim - i);
        const gsf__norm_grad_terms t = GSF__V(gsf__norm_grad_at)(job, &n, x, dy, i);
        total = gsf__vd_add_folded(total, t.h);
        weighted = gsf__vd_add_folded(weighted, t.h * t.normal);
        gsf__v_store_first(sums + i, gsf__v_load_first(sums + i, left) + t.d, left);
        gsf__v_store_first(products + i, gsf__v_madd(t.d, t.normal, gsf__v_load_first(products + i, left)), left);
    }
    const gsf__vf mean = gsf__v_set(job->centre ? (float)(gsf__vd_sum(total) / (double)dim) : 0.0f);
    const gsf__vf slope = gsf__v_set((float)(gsf__vd_sum(weighted) / (double)dim));
    for (int64_t i = 0; i < dim; i += GSF__LANES) {
        const size_t left = (size_t)(dim - i);
        const gsf__norm_grad_terms t = GSF__V(gsf__norm_grad_at)(job, &n, x, dy, i);
        gsf__vf d = n.inverse * gsf__v_nmadd(t.normal, slope, t.h - mean);
        if (job->accumulate) d = d + gsf__v_load_first(dx + i, left);
        gsf__v_store_first(dx + i, d, left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__sum_row)(const gsf__grad_job* job, int64_t row, float* sums, float* products) {
    const float *x = job->x ? job->x + row * job->ld : NULL, *dy = job->dy + row * job->ld;
    for (int64_t i = 0; i < job->columns; i += GSF__LANES) {
        const size_t left = (size_t)(job->columns - i);
        const gsf__vf d = gsf__v_load_first(dy + i, left);
        gsf__v_store_first(sums + i, gsf__v_load_first(sums + i, left) + d, left);
        if (!x) continue;
        const gsf__vf product = gsf__v_madd(d, gsf__v_load_first(x + i, left), gsf__v_load_first(products + i, left));
        gsf__v_store_first(products + i, product, left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__scale_row)(const float* x, const float* y, int64_t count, float* out) {
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        gsf__v_store_first(out + i, gsf__v_load_first(x + i, left) * gsf__v_load_first(y + i, left), left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__add_product)(const float* x, const float* y, int64_t count, float* out) {
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf before = gsf__v_load_first(out + i, left);
        gsf__v_store_first(out + i, gsf__v_madd(gsf__v_load_first(x + i, left), gsf__v_load_first(y + i, left), before), left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__gather_row)(const int32_t* at, const float* weight, int64_t taps, const float* x,
                                           int64_t channels, int add, float* y) {
    for (int64_t i = 0; i < channels; i += GSF__LANES) {
        const size_t left = (size_t)(channels - i);
        gsf__vf sum = gsf__v_set(0.0f);
        for (int64_t k = 0; k < taps; k++)
            sum = gsf__v_madd(gsf__v_set(weight[k]), gsf__v_load_first(x + at[k] * channels + i, left), sum);
        if (add) sum = sum + gsf__v_load_first(y + i, left);
        gsf__v_store_first(y + i, sum, left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__adam)(const gsf__adam_terms* terms, int64_t count, float* grad, float* m, float* v,
                                     float* value, float* average) {
    const gsf__vf beta1 = gsf__v_set(terms->beta1), beta2 = gsf__v_set(terms->beta2), rate = gsf__v_set(terms->rate);
    const gsf__vf rest1 = gsf__v_set(terms->rest1), rest2 = gsf__v_set(terms->rest2), root = gsf__v_set(terms->root);
    const gsf__vf decay = gsf__v_set(terms->decay), eps = gsf__v_set(terms->eps), blend = gsf__v_set(terms->average);
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf g = gsf__v_set(terms->scale) * gsf__v_load_first(grad + i, left);
        const gsf__vf m1 = gsf__v_madd(beta1, gsf__v_load_first(m + i, left), rest1 * g);
        const gsf__vf v1 = gsf__v_madd(beta2, gsf__v_load_first(v + i, left), rest2 * (g * g));
        const gsf__vf move = rate * m1 / gsf__v_madd(gsf__v_sqrt(v1), root, eps);
        const gsf__vf x = gsf__v_msub(decay, gsf__v_load_first(value + i, left), move);
        gsf__v_store_first(m + i, m1, left);
        gsf__v_store_first(v + i, v1, left);
        gsf__v_store_first(value + i, x, left);
        gsf__v_store_first(grad + i, gsf__v_set(0.0f), left);
        if (!average) continue;
        const gsf__vf before = gsf__v_load_first(average + i, left);
        gsf__v_store_first(average + i, gsf__v_madd(blend, x - before, before), left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__channel_sums)(const float* x, const float* dy, int64_t count, gsf__moments m, float inverse,
                                             double* sums) {
    const gsf__norm_terms n = gsf__norm_terms_of(m, inverse);
    gsf__vd total = gsf__vd_set(0.0), weighted = total;
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf d = gsf__v_load_first(dy + i, left); // 0 beyond the end
        total = gsf__vd_add_folded(total, d);
        weighted = gsf__vd_add_folded(weighted, d * gsf__norm_apply(&n, gsf__v_load_first(x + i, left)));
    }
    sums[0] += gsf__vd_sum(total);
    sums[1] += gsf__vd_sum(weighted);
}

GSF__V_KERNEL void GSF__V(gsf__channel_grad)(const float* x, const float* dy, int64_t count, gsf__moments m, float inverse,
                                             const float* by, float* dx) {
    const gsf__norm_terms n = gsf__norm_terms_of(m, inverse);
    const gsf__vf weight = gsf__v_set(by[0]), mean = gsf__v_set(by[1]), slope = gsf__v_set(by[2]);
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf h = gsf__v_msub(weight, gsf__v_load_first(dy + i, left), mean);
        const gsf__vf normal = gsf__norm_apply(&n, gsf__v_load_first(x + i, left));
        gsf__v_store_first(dx + i, n.inverse * gsf__v_nmadd(normal, slope, h), left);
    }
}

#if GSF__LANES > 1 // at one lane: the references above

GSF__V_KERNEL void GSF__V(gsf__rope_grad)(const float* dy, int64_t count, const float* cos, const float* sin, float* dx) {
    const gsf__vf zero = gsf__v_set(0.0f);
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf d = gsf__v_load_first(dy + i, left);
        const gsf__vf turned = gsf__v_turn_pairs(d, gsf__v_load_first(cos + i, left), zero - gsf__v_load_first(sin + i, left));
        gsf__v_store_first(dx + i, gsf__v_select(gsf__vm_first(left / 2 * 2), turned, d), left); // an odd last one stays
    }
}

// gsf__nn_activation_slope. Beyond the clamping the slope is 0 or 1.
GSF__V_INLINE gsf__vf gsf__v_slope(gsf__nn_activation activation, gsf__vf x) {
    const gsf__vf zero = gsf__v_set(0.0f), one = gsf__v_set(1.0f);
    if (activation == GSF__NN_GELU_TANH) {
        const gsf__vf v = gsf__v_min(gsf__v_set(12.0f), gsf__v_max(gsf__v_set(-12.0f), x)), square = v * v;
        const gsf__vf u = gsf__v_madd(square, gsf__v_set(-0.10294324f), gsf__v_set(-2.30220819f));
        const gsf__vf power = gsf__v_exp2(v * u), s = one / (one + power), t = power * s; // t = 1 - s
        const gsf__vf du = gsf__v_madd(square, gsf__v_set(0.214070916f), gsf__v_set(1.59576912f));
        return gsf__v_madd(v * du, s * t, s);
    }
    if (activation == GSF__NN_QUICK_GELU) x = gsf__v_set(1.702f) * x; // the same slope as that of SiLU there
    if (activation == GSF__NN_SILU || activation == GSF__NN_QUICK_GELU) {
        const gsf__vf v = gsf__v_min(gsf__v_set(80.0f), gsf__v_max(gsf__v_set(-80.0f), x));
        const gsf__vf power = gsf__v_exp(zero - v), s = one / (one + power);
        return gsf__v_madd(v * s, power * s, s);
    }
    if (activation == GSF__NN_GELU) {
        gsf__vf power;
        const gsf__vf z = gsf__v_gelu_limit(x), tail = gsf__v_gelu_tail(z, &power);
        const gsf__vf below = gsf__v_select(gsf__v_gt(x, zero), one - tail, tail); // of the normal distribution
        return gsf__v_madd(gsf__v_with_sign(z, x), power * gsf__v_set(0.398942280f), below);
    }
    if (activation == GSF__NN_RELU) return gsf__v_keep(gsf__v_gt(x, zero), one);
    return one;
}

GSF__V_INLINE void GSF__V(gsf__activate_grad_all)(gsf__nn_activation activation, const float* x, const float* dy,
                                                  int64_t count, float* dx) {
    for (int64_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = (size_t)(count - i);
        const gsf__vf slope = gsf__v_slope(activation, gsf__v_load_first(x + i, left));
        gsf__v_store_first(dx + i, slope * gsf__v_load_first(dy + i, left), left);
    }
}

GSF__V_KERNEL void GSF__V(gsf__activate_grad)(gsf__nn_activation activation, const float* x, const float* dy, int64_t count,
                                              float* dx) {
#define GSF_X(kind) case kind: GSF__V(gsf__activate_grad_all)(kind, x, dy, count, dx); break;
    switch (activation) {
        GSF_X(GSF__NN_LINEAR)
        GSF_X(GSF__NN_GELU_TANH)
        GSF_X(GSF__NN_SILU)
        GSF_X(GSF__NN_GELU)
        GSF_X(GSF__NN_RELU)
        GSF_X(GSF__NN_QUICK_GELU)
    }
#undef GSF_X
}

GSF__V_KERNEL void GSF__V(gsf__attention_grad_row)(float* logits, float* dp, int64_t count, float factor, float scale,
                                                   float lse, float delta) {
    const gsf__v_exp2_terms terms = gsf__v_exp2_of(1);
    const gsf__vf f = gsf__v_set(factor), to = gsf__v_set(lse), by = gsf__v_set(scale), less = gsf__v_set(delta);
    for (int64_t j = 0; j < count; j += GSF__LANES) {
        const size_t left = (size_t)(count - j);
        const gsf__vf p = gsf__v_exp2_low(&terms, gsf__v_msub(f, gsf__v_load_first(logits + j, left), to));
        gsf__v_store_first(logits + j, p, left);
        gsf__v_store_first(dp + j, by * p * (gsf__v_load_first(dp + j, left) - less), left);
    }
}

#endif
#endif // GSF__KERNELS_GRADIENTS
#ifndef GSF__ISA
#ifdef GSF_NN_TRAINING

static const gsf__grad_kernels* gsf__grad_kernels_of(gsf_cpu_level level) {
    static const gsf__grad_kernels scalar = {
        gsf__multiply_scalar, gsf__activate_grad_scalar, gsf__softmax_grad_scalar, gsf__norm_grad_row_scalar,
        gsf__sum_row_scalar, gsf__scale_row_scalar, gsf__add_product_scalar, gsf__gather_row_scalar,
        gsf__rope_grad_scalar, gsf__channel_sums_scalar, gsf__channel_grad_scalar, gsf__adam_scalar,
        gsf__attention_grad_row_scalar};
#if GSF__X86
    static const gsf__grad_kernels avx2 = {
        gsf__multiply_avx2, gsf__activate_grad_avx2, gsf__softmax_grad_avx2, gsf__norm_grad_row_avx2,
        gsf__sum_row_avx2, gsf__scale_row_avx2, gsf__add_product_avx2, gsf__gather_row_avx2,
        gsf__rope_grad_avx2, gsf__channel_sums_avx2, gsf__channel_grad_avx2, gsf__adam_avx2,
        gsf__attention_grad_row_avx2};
    static const gsf__grad_kernels avx512 = {
        gsf__multiply_avx512, gsf__activate_grad_avx512, gsf__softmax_grad_avx512, gsf__norm_grad_row_avx512,
        gsf__sum_row_avx512, gsf__scale_row_avx512, gsf__add_product_avx512, gsf__gather_row_avx512,
        gsf__rope_grad_avx512, gsf__channel_sums_avx512, gsf__channel_grad_avx512, gsf__adam_avx512,
        gsf__attention_grad_row_avx512};
    if (level >= GSF_CPU_AVX512) return &avx512;
    if (level >= GSF_CPU_AVX2) return &avx2;
#endif
    (void)level;
    return &scalar;
}

static gsf__grad_job gsf__grad_begin(const gsf_context* ctx, const float* x, const float* dy, int64_t rows, int64_t columns,
                                     float* dx) {
    gsf__grad_job job;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__grad_kernels_of(ctx->cpu_level);
    job.x = x;
    job.dy = dy;
    job.rows = rows;
    job.columns = job.ld = columns;
    job.dx = dx;
    job.chunk_rows = gsf__nn_chunk_rows(columns);
    return job;
}

// ---- training: activations, softmax

static void gsf__activate_grad_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__grad_job* job = (const gsf__grad_job*)arg;
    const int64_t begin = (int64_t)chunk * GSF__NN_CHUNK, count = gsf__least(GSF__NN_CHUNK, job->columns - begin);
    (void)worker;
    job->kernels->activate(job->activation, job->x + begin, job->dy + begin, count, job->dx + begin);
}

// x: what the activation was applied to; dx may be dy
GSF__SHARED void gsf__nn_activate_grad(gsf_context* ctx, gsf__nn_activation activation, const float* x, const float* dy,
                                       int64_t count, float* dx) {
    gsf__grad_job job = gsf__grad_begin(ctx, x, dy, 1, count, dx);
    job.activation = activation;
    gsf__parallel_for(ctx, gsf__nn_chunks(count, GSF__NN_CHUNK), gsf__activate_grad_chunk, &job);
}

static void gsf__softmax_grad_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__grad_job* job = (const gsf__grad_job*)arg;
    const int64_t n = job->columns, begin = (int64_t)chunk * job->chunk_rows;
    (void)worker;
    for (int64_t r = begin; r < begin + job->chunk_rows && r < job->rows; r++)
        job->kernels->softmax(job->x + r * n, job->dy + r * n, n, job->factor, job->dx + r * n);
}

// y: softmax(scale * x) per row; dx may be dy
GSF__SHARED void gsf__nn_softmax_grad(gsf_context* ctx, const float* y, const float* dy, int64_t rows, int64_t columns,
                                      float scale, float* dx) {
    gsf__grad_job job = gsf__grad_begin(ctx, y, dy, rows, columns, dx);
    job.factor = scale;
    gsf__parallel_for(ctx, gsf__nn_chunks(rows, job.chunk_rows), gsf__softmax_grad_chunk, &job);
}

// ---- training: sums over rows

enum { GSF__GRAD_PARTS = 64 }; // of the rows, each with its own sums
enum { GSF__GRAD_SHORT = 32 }; // rows summed in float before they are added to a sum in double

static void gsf__grad_sum_part(void* arg, size_t part, int32_t worker) {
    const gsf__grad_job* job = (const gsf__grad_job*)arg;
    const int64_t n = job->columns, begin = (int64_t)part * job->chunk_rows;
    const int64_t end = gsf__least(begin + job->chunk_rows, job->rows);
    double *sums = job->sums + (int64_t)part * n, *products = job->products + (int64_t)part * n;
    float *short_sums = job->short_sums + (int64_t)worker * 2 * n, *short_products = short_sums + n;
    memset(sums, 0, (size_t)n * sizeof(double));
    memset(products, 0, (size_t)n * sizeof(double));
    for (int64_t first = begin; first < end; first += GSF__GRAD_SHORT) {
        memset(short_sums, 0, (size_t)(2 * n) * sizeof(float));
        for (int64_t r = first; r < first + GSF__GRAD_SHORT && r < end; r++) job->add_row(job, r, short_sums, short_products);
        for (int64_t i = 0; i < n; i++) {
            sums[i] += (double)short_sums[i];
            products[i] += (double)short_products[i];
        }
    }
}

// Calls add_row for every row. Afterwards sums and products are (columns); the caller frees job->sums.
static gsf_result gsf__grad_sum(gsf_context* ctx, gsf__grad_job* job) {
    size_t count, shorts;
    job->chunk_rows = gsf__ceil_div(job->rows, GSF__GRAD_PARTS);
    const size_t parts = gsf__nn_chunks(job->rows, job->chunk_rows), columns = (size_t)job->columns;
    if (!gsf__mul_size(2 * parts, columns, &count) ||
        !gsf__mul_size((size_t)ctx->parallel.worker_count, columns, &shorts) || shorts > SIZE_MAX / 2 - count)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "gradients: %lld values per row", (long long)job->columns);
    job->sums = (double*)gsf_alloc(ctx, count + shorts, sizeof(double)); // two floats in the place of a double
    if (!job->sums) return GSF_ERROR_OUT_OF_MEMORY;
    job->products = job->sums + count / 2;
    job->short_sums = (float*)(void*)(job->sums + count);
    gsf__parallel_for(ctx, parts, gsf__grad_sum_part, job);
    for (size_t i = columns; i < count / 2; i++) {
        job->sums[i % columns] += job->sums[i];
        job->products[i % columns] += job->products[i];
    }
    return GSF_OK;
}

// sum (columns) += the sum of the rows of dy or, unless x is NULL, of dy * x: gradients of a bias and of a gate
GSF__SHARED gsf_result gsf__nn_sum_rows(gsf_context* ctx, const float* dy, const float* x, int64_t rows, int64_t columns,
                                        float* sum) {
    gsf__grad_job job = gsf__grad_begin(ctx, x, dy, rows, columns, NULL);
    if (rows < 1) return GSF_OK;
    job.add_row = job.kernels->sum;
    GSF__TRY(gsf__grad_sum(ctx, &job));
    for (int64_t i = 0; i < columns; i++) sum[i] += (float)(x ? job.products[i] : job.sums[i]);
    gsf_free(ctx, job.sums);
    return GSF_OK;
}

static void gsf__scale_rows_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__grad_job* job = (const gsf__grad_job*)arg;
    const int64_t n = job->columns, begin = (int64_t)chunk * job->chunk_rows;
    (void)worker;
    for (int64_t r = begin; r < begin + job->chunk_rows && r < job->rows; r++)
        job->kernels->scale(job->dy + r * n, job->scale, n, job->dx + r * n);
}

// y += gate * x, for each row: dx = gate * dy; dgate (columns), added to
GSF__SHARED gsf_result gsf__nn_gate_grad(gsf_context* ctx, const float* gate, const float* x, const float* dy, int64_t rows,
                                         int64_t columns, float* dx, float* dgate) {
    gsf__grad_job job = gsf__grad_begin(ctx, x, dy, rows, columns, dx);
    GSF__TRY(gsf__nn_sum_rows(ctx, dy, x, rows, columns, dgate));
    job.scale = gate;
    gsf__parallel_for(ctx, gsf__nn_chunks(rows, job.chunk_rows), gsf__scale_rows_chunk, &job);
    return GSF_OK;
}

enum { GSF__GRAD_COLUMNS = 64 }; // of a table, per chunk

typedef struct gsf__embed_grad_job {
    const int32_t* ids;
    const float* dy;
    float* dtable;
    int64_t rows, dim;
} gsf__embed_grad_job;

static void gsf__embed_grad_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__embed_grad_job* job = (const gsf__embed_grad_job*)arg;
    const int64_t begin = (int64_t)chunk * GSF__GRAD_COLUMNS, end = gsf__least(begin + GSF__GRAD_COLUMNS, job->dim);
    (void)worker;
    for (int64_t r = 0; r < job->rows; r++)
        for (int64_t i = begin; i < end; i++) job->dtable[job->ids[r] * job->dim + i] += job->dy[r * job->dim + i];
}

// Row r of the result is row ids[r] of the table (any, dim): dtable (any, dim), added to. Rows are added in order.
GSF__SHARED void gsf__nn_embed_grad(gsf_context* ctx, const int32_t* ids, const float* dy, int64_t rows, int64_t dim,
                                    float* dtable) {
    gsf__embed_grad_job job = {ids, dy, dtable, rows, dim};
    gsf__parallel_for(ctx, (size_t)gsf__ceil_div(dim, GSF__GRAD_COLUMNS), gsf__embed_grad_chunk, &job);
}

// ---- training: norms

typedef struct gsf__nn_norm_grad_desc {
    const float* x;           // (rows, dim)
    int64_t rows, dim;
    gsf__norm_vectors by;     // as in the forward pass
    float eps;
    int32_t rms;              // RMS norm: the mean is taken as 0
    const float* dy;
    float* dx;                // may be dy
    int32_t accumulate;       // dx += instead of dx = ...
    float *dweight, *dbias, *dscale, *dshift; // (dim), added to; each may be NULL
} gsf__nn_norm_grad_desc;

// y = (normalised x * weight + bias) * (1 + scale) + shift over the last dimension: layer norm, adaptive layer norm, RMS norm
GSF__SHARED gsf_result gsf__nn_norm_grad(gsf_context* ctx, const gsf__nn_norm_grad_desc* d) {
    gsf__grad_job job = gsf__grad_begin(ctx, d->x, d->dy, d->rows, d->dim, d->dx);
    if (d->rows < 0 || d->dim < 1) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "norm: rows < 0 or dim < 1");
    if (d->rows == 0) return GSF_OK;
    job.norms = gsf__norm_kernels_of(ctx->cpu_level);
    job.add_row = job.kernels->norm;
    job.weight = d->by.weight;
    job.scale = d->by.scale;
    job.eps = d->eps;
    job.centre = !d->rms;
    job.accumulate = d->accumulate;
    GSF__TRY(gsf__grad_sum(ctx, &job));
    for (int64_t i = 0; i < d->dim; i++) {
        const double sum = job.sums[i], product = job.products[i], scale = d->by.scale ? 1.0 + (double)d->by.scale[i] : 1.0;
        const double weight = d->by.weight ? (double)d->by.weight[i] : 1.0, bias = d->by.bias ? (double)d->by.bias[i] : 0.0;
        if (d->dweight) d->dweight[i] += (float)(scale * product);
        if (d->dbias) d->dbias[i] += (float)(scale * sum);
        if (d->dscale) d->dscale[i] += (float)(weight * product + bias * sum);
        if (d->dshift) d->dshift[i] += (float)sum;
    }
    gsf_free(ctx, job.sums);
    return GSF_OK;
}

typedef struct gsf__nn_head_grad_desc { // of gsf__nn_head_norm_rope with dense rows
    const float* x;           // (rows, heads*head_dim), before the norm
    int64_t rows, rope_first;
    int32_t heads, head_dim;
    const float *weight, *cos, *sin; // as in the forward pass
    float eps;
    const float* dy;
    float* dx;                // may be dy
    float *dweight, *dbias;   // (head_dim), added to; each may be NULL
} gsf__nn_head_grad_desc;

typedef struct gsf__rope_grad_job {
    const gsf__nn_head_grad_desc* desc;
    const gsf__grad_kernels* kernels;
    int64_t chunk_rows;
} gsf__rope_grad_job;

static void gsf__rope_grad_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__rope_grad_job* job = (const gsf__rope_grad_job*)arg;
    const gsf__nn_head_grad_desc* d = job->desc;
    const int64_t begin = (int64_t)chunk * job->chunk_rows, end = gsf__least(begin + job->chunk_rows, d->rows);
    const int64_t dim = d->head_dim, width = d->heads * dim;
    (void)worker;
    for (int64_t r = begin; r < end; r++) {
        const float* dy = d->dy + r * width;
        float* dx = d->dx + r * width;
        const int64_t at = (r - d->rope_first) * dim;
        if (d->cos && at >= 0)
            for (int32_t h = 0; h < d->heads; h++)
                job->kernels->rope(dy + h * dim, dim, d->cos + at, d->sin + at, dx + h * dim);
        else if (dx != dy) memcpy(dx, dy, (size_t)width * sizeof(float));
    }
}

GSF__SHARED gsf_result gsf__nn_head_grad(gsf_context* ctx, const gsf__nn_head_grad_desc* d) {
    gsf__rope_grad_job job = {d, gsf__grad_kernels_of(ctx->cpu_level), gsf__nn_chunk_rows((int64_t)d->heads * d->head_dim)};
    gsf__nn_norm_grad_desc norm;
    gsf__parallel_for(ctx, gsf__nn_chunks(d->rows, job.chunk_rows), gsf__rope_grad_chunk, &job);
    memset(&norm, 0, sizeof norm);
    norm.x = d->x;
    norm.rows = d->rows * d->heads;
    norm.dim = d->head_dim;
    norm.by.weight = d->weight;
    norm.eps = d->eps;
    norm.dy = norm.dx = d->dx;
    norm.dweight = d->dweight;
    norm.dbias = d->dbias;
    return gsf__nn_norm_grad(ctx, &norm);
}

typedef struct gsf__group_grad_job {
    const gsf__grad_kernels* kernels;
    const gsf__norm_kernels* norms;
    const float *x, *dy, *weight;
    float *dx, *dweight, *dbias;
    int64_t channels, count; // of a group; values per channel
    float eps;
} gsf__group_grad_job;

// The sums over a channel are the gradients of its bias and weight; weighted, they add up to those over the group.
static void gsf__group_grad(void* arg, size_t group, int32_t worker) {
    const gsf__group_grad_job* job = (const gsf__group_grad_job*)arg;
    const int64_t n = job->count, first = (int64_t)group * job->channels, size = job->channels * n;
    const gsf__moments m = job->norms->moments(job->x + first * n, size, 1);
    const float inverse = gsf__norm_inverse(m, size, job->eps);
    double mean = 0.0, slope = 0.0;
    (void)worker;
    for (int64_t c = first; c < first + job->channels; c++) {
        const double weight = job->weight ? (double)job->weight[c] : 1.0;
        double sums[2] = {0.0, 0.0};
        job->kernels->channel_sums(job->x + c * n, job->dy + c * n, n, m, inverse, sums);
        mean += weight * sums[0] / (double)size;
        slope += weight * sums[1] / (double)size;
        if (job->dbias) job->dbias[c] += (float)sums[0];
        if (job->dweight) job->dweight[c] += (float)sums[1];
    }
    for (int64_t c = first; c < first + job->channels; c++) {
        const float by[3] = {job->weight ? job->weight[c] : 1.0f, (float)mean, (float)slope};
        job->kernels->channel(job->x + c * n, job->dy + c * n, n, m, inverse, by, job->dx + c * n);
    }
}

// gsf__nn_group_norm: x, dy, dx (channels, count); dx may be dy; dweight, dbias (channels), added to; each may be NULL
GSF__SHARED void gsf__nn_group_norm_grad(gsf_context* ctx, const float* x, const float* dy, int64_t channels, int64_t count,
                                         int64_t groups, const float* weight, float eps, float* dx, float* dweight,
                                         float* dbias) {
    if (channels < 1 || count < 1 || groups < 1) return;
    gsf__group_grad_job job = {gsf__grad_kernels_of(ctx->cpu_level), gsf__norm_kernels_of(ctx->cpu_level), x, dy, weight,
                               dx, dweight, dbias, channels / groups, count, eps};
    gsf__parallel_for(ctx, (size_t)groups, gsf__group_grad, &job);
}

// ---- training: linear layers

enum { GSF__GRAD_TILE = 32 };

static void gsf__transpose_chunk(void* arg, size_t chunk, int32_t worker) { // GSF__GRAD_TILE columns
    const gsf__grad_job* job = (const gsf__grad_job*)arg;
    const size_t size = gsf_nn_get_dtype_size(job->dtype);
    const int64_t first = (int64_t)chunk * GSF__GRAD_TILE, last = gsf__least(first + GSF__GRAD_TILE, job->columns);
    (void)worker;
    for (int64_t top = 0; top < job->rows; top += GSF__GRAD_TILE)
        for (int64_t c = first; c < last; c++)
            for (int64_t r = top; r < top + GSF__GRAD_TILE && r < job->rows; r++)
                job->dx[c * job->rows + r] = gsf__nn_load(job->data + (size_t)(r * job->ld + c) * size, job->dtype);
}

// out (columns, rows) = the transpose of data (rows, columns) with row stride ld, widened to float
static void gsf__nn_transpose(gsf_context* ctx, const void* data, gsf_nn_dtype dtype, int64_t rows, int64_t columns, int64_t ld,
                              float* out) {
    gsf__grad_job job = gsf__grad_begin(ctx, NULL, NULL, rows, columns, out);
    job.data = (const char*)data;
    job.dtype = dtype;
    job.ld = ld;
    gsf__parallel_for(ctx, (size_t)gsf__ceil_div(columns, GSF__GRAD_TILE), gsf__transpose_chunk, &job);
}

typedef struct gsf__nn_linear_grad_desc {
    const float* x;            // (rows, in), row stride ldx
    int64_t rows, ldx;         // ldx 0: in
    const gsf_nn_tensor* weight; // (out, in); f32, bf16 or f16
    const float* dy;           // (rows, out)
    float* dx;                 // (rows, in) or NULL
    int32_t accumulate;        // dx += instead of dx = ...
    float *dweight, *dbias;    // (out, in), (out), added to; each may be NULL
} gsf__nn_linear_grad_desc;

// y = x w^T + b: dx = dy w, dw = dy^T x, db = the sum of dy's rows
GSF__SHARED gsf_result gsf__nn_linear_grad(gsf_context* ctx, const gsf__nn_linear_grad_desc* d) {
    gsf__nn_linear_desc multiply;
    int64_t in, out;
    size_t inner, outer, product;
    memset(&multiply, 0, sizeof multiply);
    multiply.x = d->x;
    multiply.rows = d->rows;
    multiply.ldx = d->ldx;
    multiply.weight = d->weight;
    multiply.y = d->dx ? d->dx : d->dweight ? d->dweight : d->dbias;
    GSF__TRY(gsf__check_linear(ctx, &multiply, &in, &out));
    if (!d->dy) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "linear: dy is missing");
    if (d->rows == 0) return GSF_OK;
    if (!gsf__mul_size((size_t)in, (size_t)d->rows, &inner) || !gsf__mul_size((size_t)out, (size_t)d->rows, &outer) ||
        inner > SIZE_MAX - outer)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "linear: %lld rows", (long long)d->rows);
    product = (size_t)d->weight->count; // of the transposed weight, then of the transposed x and dy
    float* scratch = (float*)gsf_alloc(ctx, inner + outer > product ? inner + outer : product, sizeof(float));
    if (!scratch) return GSF_ERROR_OUT_OF_MEMORY;
    gsf_result result = GSF_OK;
    if (d->dx) {
        const int64_t shape[2] = {in, out};
        const gsf_nn_tensor weight = gsf_nn_wrap_tensor(NULL, scratch, 2, shape);
        gsf__nn_transpose(ctx, d->weight->data, d->weight->dtype, out, in, in, scratch);
        memset(&multiply, 0, sizeof multiply);
        multiply.x = d->dy;
        multiply.rows = d->rows;
        multiply.weight = &weight;
        multiply.accumulate = d->accumulate;
        multiply.y = d->dx;
        result = gsf__nn_run_linear(ctx, NULL, &multiply);
    }
    if (!result && d->dweight) {
        const int64_t shape[2] = {in, d->rows};
        const gsf_nn_tensor x = gsf_nn_wrap_tensor(NULL, scratch, 2, shape);
        gsf__nn_transpose(ctx, d->x, GSF_NN_F32, d->rows, in, d->ldx ? d->ldx : in, scratch);
        gsf__nn_transpose(ctx, d->dy, GSF_NN_F32, d->rows, out, out, scratch + inner);
        memset(&multiply, 0, sizeof multiply);
        multiply.x = scratch + inner;
        multiply.rows = out;
        multiply.weight = &x;
        multiply.accumulate = 1;
        multiply.y = d->dweight;
        result = gsf__nn_run_linear(ctx, NULL, &multiply);
    }
    gsf_free(ctx, scratch);
    return !result && d->dbias ? gsf__nn_sum_rows(ctx, d->dy, NULL, d->rows, out, d->dbias) : result;
}

// ---- training: attention

/* FlashAttention-2's backward pass (Dao 2023): per head and block of keys, blocks of queries recompute the weights from the
   logits and the forward pass's lse. With p = softmax(s), s the logits:
       dp = dy v^T    ds = p (dp - sum(p dp)) = p (dp - dy out^T)    dv += p^T dy    dq += scale ds k    dk += scale ds^T q
   All five products are gsf__grad_product of blocks that stay in cache. A unit of work is one head. */
enum { GSF__ATT_GRAD_KEYS = 128, GSF__ATT_GRAD_QUERIES = 96 }; // per block; queries: a multiple of 6

typedef struct gsf__nn_attention_grad_desc {
    const gsf__nn_attention_desc* forward; // of the forward pass, with out and lse; without mask, bias and bf16
    const float* dy;        // (queries, heads*head_dim)
    float *dq, *dk, *dv;    // (queries or keys, heads*head_dim)
} gsf__nn_attention_grad_desc;

typedef struct gsf__attention_grad_job {
    gsf__nn_attention_desc desc; // with its defaults filled in
    const gsf__nn_attention_grad_desc* grad;
    const gsf__grad_kernels* kernels;
    float* scratch;
    size_t scratch_floats;       // per worker
    int64_t pitch;               // of rows of head_dim values in scratch
} gsf__attention_grad_job;

// Row stride of a block: an odd number of cache lines, so that the rows do not compete for the same cache sets.
static int64_t gsf__grad_pitch(int64_t columns) { return (gsf__ceil_div(columns, 16) | 1) * 16; }

enum { GSF__ATT_GRAD_PITCH = GSF__ATT_GRAD_KEYS + 16 };

typedef struct gsf__attention_grad_blocks { // of one worker
    float *q, *dy;           // (queries, dim), rows `pitch` apart
    float *k, *dk, *dv;      // (keys, dim)
    float *k_across, *v_across; // (dim, keys), rows GSF__ATT_GRAD_PITCH apart
    float *p, *dp;           // (queries, keys)
    float *center, *delta;   // (dim); (queries): dy out^T
} gsf__attention_grad_blocks;

// Divides the memory of a worker; returns the floats needed.
static size_t gsf__attention_grad_lay_out(const gsf__attention_grad_job* job, float* memory,
                                          gsf__attention_grad_blocks* b) {
    const size_t pitch = (size_t)job->pitch, across = (size_t)job->desc.head_dim * GSF__ATT_GRAD_PITCH;
    gsf__nn_arena arena = {memory, 0};
    b->q = gsf__nn_share(&arena, GSF__ATT_GRAD_QUERIES * pitch);
    b->dy = gsf__nn_share(&arena, GSF__ATT_GRAD_QUERIES * pitch);
    b->k = gsf__nn_share(&arena, GSF__ATT_GRAD_KEYS * pitch);
    b->dk = gsf__nn_share(&arena, GSF__ATT_GRAD_KEYS * pitch);
    b->dv = gsf__nn_share(&arena, GSF__ATT_GRAD_KEYS * pitch);
    b->k_across = gsf__nn_share(&arena, across);
    b->v_across = gsf__nn_share(&arena, across);
    b->p = gsf__nn_share(&arena, GSF__ATT_GRAD_QUERIES * GSF__ATT_GRAD_PITCH);
    b->dp = gsf__nn_share(&arena, GSF__ATT_GRAD_QUERIES * GSF__ATT_GRAD_PITCH);
    b->center = gsf__nn_share(&arena, pitch);
    b->delta = gsf__nn_share(&arena, (size_t)job->desc.queries);
    return arena.used;
}

// to[r pitch + i] = from[r ld + i]
static void gsf__attention_grad_copy(const float* from, int64_t ld, int64_t rows, int64_t dim, int64_t pitch, float* to) {
    for (int64_t r = 0; r < rows; r++) memcpy(to + r * pitch, from + r * ld, (size_t)dim * sizeof(float));
}

// c = a b or, with `add`, c += a b
static void gsf__attention_grad_multiply(const gsf__attention_grad_job* job, const float* a, int64_t a_row, int64_t a_step,
                                         int64_t rows, const float* b, int64_t ldb, int64_t count, int64_t columns, float* c,
                                         int64_t ldc, int add) {
    const gsf__grad_product product = {a, b, c, a_row, a_step, ldb, ldc, rows, columns, count};
    for (int64_t r = 0; r < rows && !add; r++) memset(c + r * ldc, 0, (size_t)columns * sizeof(float));
    job->kernels->multiply(&product);
}

// Queries `first` ... of a head against the block of `keys` keys.
static void gsf__attention_grad_block(const gsf__attention_grad_job* job, const gsf__attention_grad_blocks* b, int64_t head,
                                      int64_t first, int64_t keys) {
    const gsf__nn_attention_desc* d = &job->desc;
    const int64_t dim = d->head_dim, width = d->heads * dim, column = head * dim, across = GSF__ATT_GRAD_PITCH;
    const int64_t queries = gsf__least(GSF__ATT_GRAD_QUERIES, d->queries - first), pitch = job->pitch;
    const float *lse = d->lse + head * d->queries + first, *delta = b->delta + first;
    gsf__attention_grad_copy(d->q + first * d->ldq + column, d->ldq, queries, dim, pitch, b->q);
    gsf__attention_grad_copy(job->grad->dy + first * width + column, width, queries, dim, pitch, b->dy);
    gsf__attention_grad_multiply(job, b->q, pitch, 1, queries, b->k_across, across, dim, keys, b->p, across, 0);
    gsf__attention_grad_multiply(job, b->dy, pitch, 1, queries, b->v_across, across, dim, keys, b->dp, across, 0);
    for (int64_t r = 0; r < queries; r++)
        job->kernels->attention(b->p + r * across, b->dp + r * across, keys, d->scale * 1.44269504f, d->scale, lse[r],
                                delta[r]);
    gsf__attention_grad_multiply(job, b->p, 1, across, keys, b->dy, pitch, queries, dim, b->dv, pitch, 1);
    gsf__attention_grad_multiply(job, b->dp, 1, across, keys, b->q, pitch, queries, dim, b->dk, pitch, 1);
    gsf__attention_grad_multiply(job, b->dp, across, 1, queries, b->k, pitch, keys, dim,
                                 job->grad->dq + first * width + column, width, 1);
}

static void gsf__attention_grad_head(void* arg, size_t index, int32_t worker) {
    const gsf__attention_grad_job* job = (const gsf__attention_grad_job*)arg;
    const gsf__nn_attention_desc* d = &job->desc;
    const int64_t dim = d->head_dim, width = d->heads * dim, head = (int64_t)index, column = head * dim;
    gsf__attention_grad_blocks b;
    gsf__attention_grad_lay_out(job, job->scratch + (size_t)worker * job->scratch_floats, &b);
    gsf__attention_center(d, column, b.center);
    for (int64_t r = 0; r < d->queries; r++) {
        const float *dy = job->grad->dy + r * width + column, *out = d->out + r * d->ldo + column;
        double delta = 0.0;
        for (int64_t i = 0; i < dim; i++) delta += (double)dy[i] * (double)out[i];
        b.delta[r] = (float)delta;
        memset(job->grad->dq + r * width + column, 0, (size_t)dim * sizeof(float));
    }
    for (int64_t key = 0; key < d->keys; key += GSF__ATT_GRAD_KEYS) {
        const int64_t keys = gsf__least(GSF__ATT_GRAD_KEYS, d->keys - key);
        for (int64_t j = 0; j < keys; j++) {
            const float *k = d->k + (key + j) * d->ldk + column, *v = d->v + (key + j) * d->ldv + column;
            for (int64_t i = 0; i < dim; i++) {
                b.k[j * job->pitch + i] = b.k_across[i * GSF__ATT_GRAD_PITCH + j] = k[i] - b.center[i];
                b.v_across[i * GSF__ATT_GRAD_PITCH + j] = v[i];
            }
        }
        memset(b.dk, 0, (size_t)(keys * job->pitch) * sizeof(float));
        memset(b.dv, 0, (size_t)(keys * job->pitch) * sizeof(float));
        for (int64_t first = 0; first < d->queries; first += GSF__ATT_GRAD_QUERIES)
            gsf__attention_grad_block(job, &b, head, first, keys);
        gsf__attention_grad_copy(b.dk, job->pitch, keys, dim, width, job->grad->dk + key * width + column);
        gsf__attention_grad_copy(b.dv, job->pitch, keys, dim, width, job->grad->dv + key * width + column);
    }
}

GSF__SHARED gsf_result gsf__nn_attention_grad(gsf_context* ctx, const gsf__nn_attention_grad_desc* desc) {
    gsf__attention_grad_blocks blocks;
    gsf__attention_grad_job job;
    size_t count;
    memset(&job, 0, sizeof job);
    job.grad = desc;
    job.desc = *desc->forward;
    gsf__nn_attention_desc* d = &job.desc;
    if (d->mask || d->bias || d->queries < 1 || d->keys < 1 || d->heads < 1 || d->head_dim < 1 || !d->out || !d->lse)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "attention: gradients need out and lse; they take no mask, no bias and no empty input");
    gsf__attention_fill_in(d);
    job.kernels = gsf__grad_kernels_of(ctx->cpu_level);
    job.pitch = gsf__grad_pitch(d->head_dim);
    job.scratch_floats = gsf__attention_grad_lay_out(&job, NULL, &blocks);
    if (!gsf__mul_size(job.scratch_floats, (size_t)ctx->parallel.worker_count, &count))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "attention: %lld queries", (long long)d->queries);
    job.scratch = (float*)gsf_alloc(ctx, count, sizeof(float));
    if (!job.scratch) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__parallel_for(ctx, (size_t)d->heads, gsf__attention_grad_head, &job);
    gsf_free(ctx, job.scratch);
    return GSF_OK;
}

// ---- training: convolution

typedef struct gsf__nn_conv_grad_desc {
    const gsf__nn_conv_desc* forward; // `y`, `bias` and `accumulate` are not read
    const float* dy;           // as y
    float *dx, *dbefore;       // as x, as before; each may be NULL
    int32_t accumulate;        // dx += instead of dx = ...
    float *dweight, *dbias;    // (out, in, ...), (out), added to; each may be NULL
} gsf__nn_conv_grad_desc;

/* dx is itself a convolution, of dy by the transposed kernel, upside down and mirrored: forward frames s, s + 1, s + 2
   contribute to frame s. Frames before the first are the first one again, or `before`. A convolution that halves is one
   of dy with zeros between its pixels. */
typedef struct gsf__conv_grad_job {
    const gsf__nn_conv_grad_desc* desc;
    const gsf__grad_kernels* kernels;
    gsf__conv_layer layer;     // of the forward pass
    int64_t height, width;     // of dy
    int64_t bands, band_rows;  // of the rows of all of dy's frames
    float* sums;               // (bands, taps, in, out)
} gsf__conv_grad_job;

static int64_t gsf__conv_flip(int64_t tap, int64_t kernel) { // within a frame of the kernel
    return tap / (kernel * kernel) * kernel * kernel + kernel * kernel - 1 - tap % (kernel * kernel);
}

// out (in, out, taps): the transposed, mirrored kernel
static void gsf__conv_flip_weight(const gsf__conv_layer* layer, float* out) {
    const int64_t taps = gsf__conv_taps(layer);
    float values[GSF__CONV_TAPS];
    for (int64_t o = 0; o < layer->out; o++)
        for (int64_t i = 0; i < layer->in; i++) {
            gsf_nn_convert_tensor(layer->weight, (o * layer->in + i) * taps, taps, values);
            for (int64_t t = 0; t < taps; t++)
                out[(i * layer->out + o) * taps + gsf__conv_flip(t, layer->kernel)] = values[t];
        }
}

// Writes dy (height, width, channels) into a bordered frame of zeros, at every second pixel from (1, 1) on.
static void gsf__conv_spread(const float* dy, int64_t height, int64_t width, int64_t channels, int64_t out_width, float* out) {
    for (int64_t y = 0; y < height; y++)
        for (int64_t x = 0; x < width; x++)
            memcpy(out + ((2 * y + 1) * (out_width + 2) + 2 * x + 2) * channels, dy + (y * width + x) * channels,
                   (size_t)channels * sizeof(float));
}

static gsf_result gsf__conv_grad_input(gsf_context* ctx, const gsf__conv_grad_job* g) {
    const gsf__nn_conv_desc* f = g->desc->forward;
    const int64_t in = g->layer.in, out = g->layer.out, frame = gsf__conv_frame_size(f->height, f->width, out);
    const int64_t plane = f->height * f->width * in, kt = g->layer.kt;
    gsf__conv_layer layer = g->layer;
    layer.in = out;
    layer.out = in;
    layer.bias = NULL;
    const size_t taps = (size_t)layer.weight->count, packed = (size_t)gsf__conv_packed(&layer);
    float* memory = (float*)gsf_alloc_zeroed(ctx, 4 * (size_t)frame + taps + packed, sizeof(float));
    if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
    float *flipped = memory + 4 * frame, *weights = flipped + taps; // three frames of dy and one of zeros
    const int64_t shape[5] = {in, out, kt, layer.kernel, layer.kernel};
    const gsf_nn_tensor weight = gsf_nn_wrap_tensor(f->weight->name, flipped, 5, shape);
    gsf__conv_flip_weight(&g->layer, flipped);
    layer.weight = &weight;
    gsf__conv_pack(ctx, &layer, weights);
    gsf__conv_job job = gsf__conv_begin(ctx, &layer, f->height, f->width, 0, weights);
    gsf__conv_fill fill;
    memset(&fill, 0, sizeof fill);
    fill.kernels = job.kernels;
    fill.height = f->height;
    fill.width = f->width;
    fill.channels = out;
    for (int64_t s = f->frames - 1; s >= (kt == 3 ? -2 : 0); s--) {
        if (s >= 0) {
            fill.x = g->desc->dy + s * g->height * g->width * out;
            fill.out = memory + s % 3 * frame;
            if (f->halve) gsf__conv_spread(fill.x, g->height, g->width, out, f->width, fill.out);
            else gsf__conv_fill_frame(ctx, &fill);
        }
        for (int64_t i = 0; i < kt; i++) {
            const int64_t source = s + kt - 1 - i;
            job.in[i] = memory + (source < 0 || source >= f->frames ? 3 : source % 3) * frame;
        }
        job.accumulate = s < 0 && !f->before ? 1 : s >= 0 && g->desc->accumulate;
        job.out = s < 0 && f->before ? g->desc->dbefore ? g->desc->dbefore + (s + 2) * plane : NULL
                                     : g->desc->dx + (s < 0 ? 0 : s) * plane;
        if (job.out) gsf__conv_frame(ctx, &job, NULL);
    }
    gsf_free(ctx, memory);
    return GSF_OK;
}

enum { GSF__CONV_GRAD_CHANNELS = 48, GSF__CONV_GRAD_BANDS = 16 }; // input channels per chunk; at most so many bands
enum { GSF__CONV_GRAD_SUMS = 1 << 22 };                           // floats of all bands, unless one band has more

// A chunk is one band, one tap and a few input channels: per row of dy, a product (in, pixels) by (pixels, out).
static void gsf__conv_grad_weight(void* arg, size_t chunk, int32_t worker) {
    const gsf__conv_grad_job* g = (const gsf__conv_grad_job*)arg;
    const gsf__nn_conv_desc* f = g->desc->forward;
    const int64_t in = g->layer.in, out = g->layer.out, kernel = g->layer.kernel, taps = gsf__conv_taps(&g->layer);
    const int64_t pieces = gsf__ceil_div(in, GSF__CONV_GRAD_CHANNELS), unit = (int64_t)chunk / pieces; // of bands and taps
    const int64_t channel = (int64_t)chunk % pieces * GSF__CONV_GRAD_CHANNELS, band = unit / taps, tap = unit % taps;
    const int64_t stride = f->halve ? 2 : 1, pad = f->halve ? 0 : kernel / 2, last = g->band_rows * (band + 1);
    const int64_t dx = tap % kernel - pad, dy = tap / kernel % kernel - pad, dt = tap / (kernel * kernel) - g->layer.kt + 1;
    const int64_t room = f->width - 1 - dx, x0 = dx < 0 ? 1 : 0;
    const int64_t x1 = room < 0 ? 0 : gsf__least(g->width, room / stride + 1);
    gsf__grad_product p;
    p.a_row = 1;
    p.a_step = stride * in;
    p.ldb = p.ldc = p.columns = out;
    p.rows = gsf__least(in - channel, GSF__CONV_GRAD_CHANNELS);
    p.count = x1 - x0;
    p.c = g->sums + (unit * in + channel) * out;
    (void)worker;
    memset(p.c, 0, (size_t)(p.rows * out) * sizeof(float));
    for (int64_t r = band * g->band_rows; p.count > 0 && r < last && r < f->frames * g->height; r++) {
        const int64_t y = r % g->height * stride + dy, t = r / g->height + dt;
        if (y < 0 || y >= f->height) continue;
        const float* frame = t >= 0 ? f->x + t * f->height * f->width * in
                                    : f->before ? f->before + (t + 2) * f->height * f->width * in : f->x;
        p.a = frame + (y * f->width + x0 * stride + dx) * in + channel;
        p.b = g->desc->dy + (r * g->width + x0) * out;
        g->kernels->multiply(&p);
    }
}

// Gradients of gsf__nn_convolve.
GSF__SHARED gsf_result gsf__nn_conv_grad(gsf_context* ctx, const gsf__nn_conv_grad_desc* d) {
    gsf__nn_conv_desc forward = *d->forward;
    gsf__conv_grad_job g;
    memset(&g, 0, sizeof g);
    forward.y = d->dx ? d->dx : d->dweight ? d->dweight : d->dbias; // is not written
    forward.bias = NULL;
    GSF__TRY(gsf__check_conv(ctx, &forward, &g.layer));
    if (!d->dy) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "convolution: dy is missing");
    g.desc = d;
    g.kernels = gsf__grad_kernels_of(ctx->cpu_level);
    g.height = forward.halve ? forward.height / 2 : forward.height;
    g.width = forward.halve ? forward.width / 2 : forward.width;
    if (d->dx) GSF__TRY(gsf__conv_grad_input(ctx, &g));
    const int64_t rows = forward.frames * g.height, taps = gsf__conv_taps(&g.layer), size = forward.weight->count;
    if (d->dweight) {
        const int64_t most = gsf__least(GSF__CONV_GRAD_BANDS, gsf__least(GSF__CONV_GRAD_SUMS / size, rows));
        g.band_rows = gsf__ceil_div(rows, most > 1 ? most : 1);
        g.bands = gsf__ceil_div(rows, g.band_rows);
        g.sums = (float*)gsf_alloc(ctx, (size_t)g.bands, (size_t)size * sizeof(float));
        if (!g.sums) return GSF_ERROR_OUT_OF_MEMORY;
        const int64_t pieces = gsf__ceil_div(g.layer.in, GSF__CONV_GRAD_CHANNELS);
        gsf__parallel_for(ctx, (size_t)(g.bands * taps * pieces), gsf__conv_grad_weight, &g);
        for (int64_t o = 0; o < g.layer.out; o++)
            for (int64_t i = 0; i < g.layer.in; i++)
                for (int64_t t = 0; t < taps; t++) {
                    double sum = 0.0;
                    for (int64_t band = 0; band < g.bands; band++)
                        sum += (double)g.sums[((band * taps + t) * g.layer.in + i) * g.layer.out + o];
                    d->dweight[(o * g.layer.in + i) * taps + t] += (float)sum;
                }
        gsf_free(ctx, g.sums);
    }
    return d->dbias ? gsf__nn_sum_rows(ctx, d->dy, NULL, rows * g.width, g.layer.out, d->dbias) : GSF_OK;
}

// ---- training: depthwise convolution

typedef struct gsf__nn_depthwise { // k x k, k odd, zeros around the image; forward and backward
    const float* x;            // (frames, height, width, channels)
    int64_t frames, height, width, channels, kernel;
    const float *weight, *bias; // (channels, 1, k, k), as PyTorch stores it; (channels) or NULL
    float* y;                  // forward: as x
    const float* dy;           // backward
    float *dx, *dweight, *dbias; // as x; as weight and bias, added to; each may be NULL
} gsf__nn_depthwise;

typedef struct gsf__depthwise_job {
    const gsf__grad_kernels* kernels;
    gsf__nn_depthwise desc;
    const float *from, *weights; // (k^2, channels)
    float *to, *shorts;          // shorts: per worker, (2, channels)
    double* sums;                // (bands, k^2, channels)
    int64_t bands, band_rows;
} gsf__depthwise_job;

// (k^2, channels) from (channels, k^2), mirrored for the backward pass
static void gsf__depthwise_pack(const gsf__nn_depthwise* d, int mirrored, float* out) {
    const int64_t taps = d->kernel * d->kernel;
    for (int64_t t = 0; t < taps; t++)
        for (int64_t c = 0; c < d->channels; c++)
            out[(mirrored ? taps - 1 - t : t) * d->channels + c] = d->weight[c * taps + t];
}

static void gsf__depthwise_row(void* arg, size_t row, int32_t worker) {
    const gsf__depthwise_job* job = (const gsf__depthwise_job*)arg;
    const gsf__nn_depthwise* d = &job->desc;
    const int64_t h = d->height, w = d->width, c = d->channels, half = d->kernel / 2, y = (int64_t)row % h;
    (void)worker;
    for (int64_t x = 0; x < w; x++) {
        float* to = job->to + ((int64_t)row * w + x) * c;
        if (d->bias && job->to == d->y) memcpy(to, d->bias, (size_t)c * sizeof(float));
        else memset(to, 0, (size_t)c * sizeof(float));
        for (int64_t t = 0; t < d->kernel * d->kernel; t++) {
            const int64_t sy = y + t / d->kernel - half, sx = x + t % d->kernel - half;
            if (sy < 0 || sy >= h || sx < 0 || sx >= w) continue;
            job->kernels->add_product(job->weights + t * c, job->from + (((int64_t)row - y + sy) * w + sx) * c, c, to);
        }
    }
}

static gsf_result gsf__depthwise_run(gsf_context* ctx, const gsf__nn_depthwise* d, const float* from, int mirrored, float* to) {
    gsf__depthwise_job job;
    memset(&job, 0, sizeof job);
    float* weights = (float*)gsf_alloc(ctx, (size_t)(d->kernel * d->kernel), (size_t)d->channels * sizeof(float));
    if (!weights) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__depthwise_pack(d, mirrored, weights);
    job.kernels = gsf__grad_kernels_of(ctx->cpu_level);
    job.desc = *d;
    job.from = from;
    job.to = to;
    job.weights = weights;
    gsf__parallel_for(ctx, (size_t)(d->frames * d->height), gsf__depthwise_row, &job);
    gsf_free(ctx, weights);
    return GSF_OK;
}

static gsf_result gsf__check_depthwise(gsf_context* ctx, const gsf__nn_depthwise* d) {
    if (d->x && d->weight && d->frames > 0 && d->height > 0 && d->width > 0 && d->channels > 0 && d->kernel > 0 &&
        d->kernel % 2 == 1)
        return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "depthwise convolution: x, weight or a size is missing, or k is even");
}

GSF__SHARED gsf_result gsf__nn_depthwise_forward(gsf_context* ctx, const gsf__nn_depthwise* d) {
    GSF__TRY(gsf__check_depthwise(ctx, d));
    return gsf__depthwise_run(ctx, d, d->x, 0, d->y);
}

// A chunk is one band of rows and one tap: per channel, the sum of x dy over the pixels that the tap sees.
static void gsf__depthwise_grad_weight(void* arg, size_t chunk, int32_t worker) {
    const gsf__depthwise_job* job = (const gsf__depthwise_job*)arg;
    const gsf__nn_depthwise* d = &job->desc;
    const int64_t taps = d->kernel * d->kernel, tap = (int64_t)chunk % taps, band = (int64_t)chunk / taps, c = d->channels;
    const int64_t dx = tap % d->kernel - d->kernel / 2, dy = tap / d->kernel - d->kernel / 2;
    const int64_t x0 = dx < 0 ? -dx : 0, x1 = dx > 0 ? d->width - dx : d->width;
    const int64_t end = gsf__least((band + 1) * job->band_rows, d->frames * d->height);
    double* sums = job->sums + (int64_t)chunk * c;
    float* part = job->shorts + worker * c;
    memset(sums, 0, (size_t)c * sizeof(double));
    for (int64_t r = band * job->band_rows; r < end; r++) {
        if (r % d->height + dy < 0 || r % d->height + dy >= d->height) continue;
        for (int64_t first = x0; first < x1; first += GSF__GRAD_SHORT) {
            memset(part, 0, (size_t)c * sizeof(float));
            for (int64_t x = first; x < first + GSF__GRAD_SHORT && x < x1; x++)
                job->kernels->add_product(d->x + ((r + dy) * d->width + x + dx) * c, d->dy + (r * d->width + x) * c, c, part);
            for (int64_t i = 0; i < c; i++) sums[i] += (double)part[i];
        }
    }
}

enum { GSF__DEPTHWISE_BANDS = 16 };

GSF__SHARED gsf_result gsf__nn_depthwise_backward(gsf_context* ctx, const gsf__nn_depthwise* d) {
    GSF__TRY(gsf__check_depthwise(ctx, d));
    const int64_t rows = d->frames * d->height, taps = d->kernel * d->kernel, c = d->channels;
    if (d->dx) GSF__TRY(gsf__depthwise_run(ctx, d, d->dy, 1, d->dx));
    if (d->dweight) {
        gsf__depthwise_job job;
        memset(&job, 0, sizeof job);
        job.kernels = gsf__grad_kernels_of(ctx->cpu_level);
        job.desc = *d;
        job.band_rows = gsf__ceil_div(rows, GSF__DEPTHWISE_BANDS);
        job.bands = gsf__ceil_div(rows, job.band_rows);
        const size_t sums = (size_t)(job.bands * taps); // then of each worker, two floats in the place of a double
        job.sums = (double*)gsf_alloc(ctx, sums + (size_t)ctx->parallel.worker_count, (size_t)c * sizeof(double));
        if (!job.sums) return GSF_ERROR_OUT_OF_MEMORY;
        job.shorts = (float*)(void*)(job.sums + sums * (size_t)c);
        gsf__parallel_for(ctx, sums, gsf__depthwise_grad_weight, &job);
        for (int64_t i = 0; i < c; i++)
            for (int64_t t = 0; t < taps; t++) {
                double sum = 0.0;
                for (int64_t band = 0; band < job.bands; band++) sum += job.sums[(band * taps + t) * c + i];
                d->dweight[i * taps + t] += (float)sum;
            }
        gsf_free(ctx, job.sums);
    }
    return d->dbias ? gsf__nn_sum_rows(ctx, d->dy, NULL, rows * d->width, c, d->dbias) : GSF_OK;
}

// ---- training: resampling and warping

/* Layers of image networks, forward and backward; images are channels-last. Resampling and warping are sparse matrices
   over pixels: an output pixel is a weighted sum of a few input pixels (taps). Backward is the transposed matrix, whose
   rows list the taps of an input pixel in order of the output pixels, so both directions are the same gathering of rows. */
typedef struct gsf__nn_sparse { // rows of taps; one allocation, freed with gsf_free(ctx, first)
    int64_t rows;
    int64_t* first;   // (rows + 1): of each row, into at and weight
    int32_t* at;
    float* weight;
} gsf__nn_sparse;

typedef struct gsf__nn_taps { gsf__nn_sparse forward, backward; } gsf__nn_taps; // by output pixel; by input pixel

static void gsf__nn_destroy_taps(gsf_context* ctx, gsf__nn_taps* taps) {
    gsf_free(ctx, taps->forward.first);
    gsf_free(ctx, taps->backward.first);
    memset(taps, 0, sizeof *taps);
}

static gsf_result gsf__nn_make_sparse(gsf_context* ctx, int64_t rows, int64_t count, gsf__nn_sparse* out) {
    memset(out, 0, sizeof *out);
    if (rows > INT32_MAX || count > INT64_MAX / 16 || (uint64_t)(rows + 1 + count) > SIZE_MAX / sizeof(int64_t))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "resampling: %lld pixels", (long long)rows);
    out->first = (int64_t*)gsf_alloc_zeroed(ctx, (size_t)(rows + 1 + count), sizeof(int64_t)); // at and weight: 4 bytes each
    if (!out->first) return GSF_ERROR_OUT_OF_MEMORY;
    out->rows = rows;
    out->at = (int32_t*)(void*)(out->first + rows + 1);
    out->weight = (float*)(void*)(out->at + count);
    return GSF_OK;
}

// Transposes taps->forward, whose columns are `inputs` pixels.
static gsf_result gsf__nn_transpose_taps(gsf_context* ctx, int64_t inputs, gsf__nn_taps* taps) {
    const gsf__nn_sparse* f = &taps->forward;
    gsf__nn_sparse* b = &taps->backward;
    const int64_t count = f->first[f->rows];
    GSF__TRY(gsf__nn_make_sparse(ctx, inputs, count, b));
    for (int64_t k = 0; k < count; k++) b->first[f->at[k] + 1]++;
    for (int64_t i = 0; i < inputs; i++) b->first[i + 1] += b->first[i];
    for (int64_t r = 0; r < f->rows; r++)
        for (int64_t k = f->first[r]; k < f->first[r + 1]; k++) {
            const int64_t to = b->first[f->at[k]]++; // the start moves to the end: the next row's start
            b->at[to] = (int32_t)r;
            b->weight[to] = f->weight[k];
        }
    memmove(b->first + 1, b->first, (size_t)inputs * sizeof(int64_t));
    b->first[0] = 0;
    return GSF_OK;
}

typedef struct gsf__nn_grid { int64_t height, width; } gsf__nn_grid; // of an image

// Appends the taps of one output pixel: bilinear at (x, y), pixel centres at integers. Taps outside of the image count as
// zeros; a position that is not finite has no taps.
static void gsf__nn_add_taps(gsf__nn_sparse* s, int64_t row, gsf__nn_grid from, float x, float y) {
    int64_t k = s->first[row];
    if (x > -1.0f && y > -1.0f && x < (float)from.width && y < (float)from.height) {
        const float left = floorf(x), top = floorf(y), wx = x - left, wy = y - top;
        for (int i = 0; i < 4; i++) {
            const int64_t c = (int64_t)left + i % 2, r = (int64_t)top + i / 2;
            const float weight = (i % 2 ? wx : 1.0f - wx) * (i / 2 ? wy : 1.0f - wy);
            if (weight == 0.0f || c < 0 || r < 0 || c >= from.width || r >= from.height) continue;
            s->at[k] = (int32_t)(r * from.width + c);
            s->weight[k++] = weight;
        }
    }
    s->first[row + 1] = k;
}

// Samples an image at `positions`: (to.height, to.width, 2), x then y, in pixels from the centre of the first one.
// Positions have no gradient.
GSF__SHARED gsf_result gsf__nn_make_warp(gsf_context* ctx, gsf__nn_grid from, gsf__nn_grid to, const float* positions,
                                         gsf__nn_taps* out) {
    const int64_t outputs = to.height * to.width;
    memset(out, 0, sizeof *out);
    if (from.height < 1 || from.width < 1 || outputs < 1 || from.height > INT32_MAX / from.width)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "warping: %lld x %lld pixels", (long long)from.width,
                        (long long)from.height);
    gsf_result result = gsf__nn_make_sparse(ctx, outputs, 4 * outputs, &out->forward);
    for (int64_t r = 0; !result && r < outputs; r++)
        gsf__nn_add_taps(&out->forward, r, from, positions[2 * r], positions[2 * r + 1]);
    if (!result) result = gsf__nn_transpose_taps(ctx, from.height * from.width, out);
    if (result) gsf__nn_destroy_taps(ctx, out);
    return result;
}

static float gsf__nn_resize_position(int64_t i, int64_t from, int64_t to, int bilinear) {
    const double scale = (double)from / (double)to, at = ((double)i + 0.5) * scale - 0.5, last = (double)(from - 1);
    if (!bilinear) return (float)(i * from / to);
    return (float)(at < 0.0 ? 0.0 : at > last ? last : at);
}

// Resizes an image: nearest, or bilinear without antialiasing (PyTorch's interpolate with align_corners=False).
GSF__SHARED gsf_result gsf__nn_make_resize(gsf_context* ctx, gsf__nn_grid from, gsf__nn_grid to, int bilinear,
                                           gsf__nn_taps* out) {
    memset(out, 0, sizeof *out);
    if (to.height < 1 || to.width < 1 || to.height > INT32_MAX / to.width || from.height < 1 || from.width < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "resampling: %lld x %lld pixels to %lld x %lld",
                        (long long)from.width, (long long)from.height, (long long)to.width, (long long)to.height);
    float* positions = (float*)gsf_alloc(ctx, (size_t)(to.height * to.width), 2 * sizeof(float));
    if (!positions) return GSF_ERROR_OUT_OF_MEMORY;
    for (int64_t y = 0; y < to.height; y++)
        for (int64_t x = 0; x < to.width; x++) {
            positions[2 * (y * to.width + x)] = gsf__nn_resize_position(x, from.width, to.width, bilinear);
            positions[2 * (y * to.width + x) + 1] = gsf__nn_resize_position(y, from.height, to.height, bilinear);
        }
    const gsf_result result = gsf__nn_make_warp(ctx, from, to, positions, out);
    gsf_free(ctx, positions);
    return result;
}

typedef struct gsf__gather_job {
    const gsf__grad_kernels* kernels;
    const gsf__nn_sparse* by;
    const float* x;
    float* y;
    int64_t channels, chunk_rows;
    int add;
} gsf__gather_job;

static void gsf__nn_gather_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__gather_job* job = (const gsf__gather_job*)arg;
    const gsf__nn_sparse* s = job->by;
    const int64_t begin = (int64_t)chunk * job->chunk_rows, end = gsf__least(begin + job->chunk_rows, s->rows);
    (void)worker;
    for (int64_t r = begin; r < end; r++)
        job->kernels->gather(s->at + s->first[r], s->weight + s->first[r], s->first[r + 1] - s->first[r], job->x,
                             job->channels, job->add, job->y + r * job->channels);
}

// y (rows, channels) = by x or, with `add`, y += by x. A layer's forward pass takes taps->forward; its backward pass takes
// taps->backward, with dy for x and dx for y.
GSF__SHARED void gsf__nn_gather(gsf_context* ctx, const gsf__nn_sparse* by, const float* x, int64_t channels, int add,
                                float* y) {
    gsf__gather_job job = {gsf__grad_kernels_of(ctx->cpu_level), by, x, y, channels, gsf__nn_chunk_rows(4 * channels), add};
    gsf__parallel_for(ctx, gsf__nn_chunks(by->rows, job.chunk_rows), gsf__nn_gather_chunk, &job);
}

typedef struct gsf__shuffle_job {
    const float* from;
    float* to;
    int64_t width, channels, factor; // of the coarse image; channels of the fine one
    int back;
} gsf__shuffle_job;

static void gsf__shuffle_row(void* arg, size_t row, int32_t worker) { // of the fine image
    const gsf__shuffle_job* job = (const gsf__shuffle_job*)arg;
    const int64_t f = job->factor, c = job->channels, y = (int64_t)row / f, inner = (int64_t)row % f * f;
    (void)worker;
    for (int64_t x = 0; x < job->width * f; x++)
        for (int64_t i = 0; i < c; i++) {
            const int64_t fine = ((int64_t)row * job->width * f + x) * c + i;
            const int64_t coarse = ((y * job->width + x / f) * c + i) * f * f + inner + x % f;
            if (job->back) job->to[coarse] = job->from[fine];
            else job->to[fine] = job->from[coarse];
        }
}

// x (rows, width, channels f^2) to y (f rows, f width, channels), channels in PyTorch's order; `back`: from y to x, which
// is also the backward pass. `rows` may be those of several images.
GSF__SHARED void gsf__nn_shuffle_pixels(gsf_context* ctx, const float* from, int64_t rows, int64_t width, int64_t channels,
                                        int64_t factor, int back, float* to) {
    gsf__shuffle_job job = {from, to, width, channels, factor, back};
    gsf__parallel_for(ctx, (size_t)(rows * factor), gsf__shuffle_row, &job);
}

// ---- training: blends of candidates

typedef struct gsf__nn_blend {
    int64_t pixels, candidates, channels;
    const float *x, *weights;   // (pixels, candidates, channels); (pixels, candidates): gsf__nn_softmax of the logits
    float* y;                   // forward: (pixels, channels)
    const float* dy;            // backward
    float *dx, *dlogits;        // as x (may be NULL), as weights
} gsf__nn_blend;

static void gsf__nn_blend_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__nn_blend* b = (const gsf__nn_blend*)arg;
    const int64_t n = b->candidates, c = b->channels, rows = gsf__nn_chunk_rows(n * c), begin = (int64_t)chunk * rows;
    (void)worker;
    for (int64_t p = begin; p < begin + rows && p < b->pixels; p++) {
        const float *x = b->x + p * n * c, *weight = b->weights + p * n;
        float* y = b->y + p * c;
        for (int64_t i = 0; i < c; i++) y[i] = 0.0f;
        for (int64_t k = 0; k < n; k++)
            for (int64_t i = 0; i < c; i++) y[i] += weight[k] * x[k * c + i];
    }
}

static void gsf__blend_grad_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__nn_blend* b = (const gsf__nn_blend*)arg;
    const int64_t n = b->candidates, c = b->channels, rows = gsf__nn_chunk_rows(n * c), begin = (int64_t)chunk * rows;
    (void)worker;
    for (int64_t p = begin; p < begin + rows && p < b->pixels; p++) {
        const float *x = b->x + p * n * c, *weight = b->weights + p * n, *dy = b->dy + p * c;
        float *dlogits = b->dlogits + p * n, mean = 0.0f;
        for (int64_t k = 0; k < n; k++) {
            float dot = 0.0f;
            for (int64_t i = 0; i < c; i++) dot += dy[i] * x[k * c + i];
            mean += weight[k] * dot;
            dlogits[k] = dot;
        }
        for (int64_t k = 0; k < n; k++) {
            dlogits[k] = weight[k] * (dlogits[k] - mean);
            for (int64_t i = 0; b->dx && i < c; i++) b->dx[(p * n + k) * c + i] = weight[k] * dy[i];
        }
    }
}

// y = the sum over a pixel's candidates of weight * x
GSF__SHARED void gsf__nn_blend_forward(gsf_context* ctx, gsf__nn_blend* b) {
    gsf__parallel_for(ctx, gsf__nn_chunks(b->pixels, gsf__nn_chunk_rows(b->candidates * b->channels)), gsf__nn_blend_chunk, b);
}
GSF__SHARED void gsf__nn_blend_backward(gsf_context* ctx, gsf__nn_blend* b) {
    gsf__parallel_for(ctx, gsf__nn_chunks(b->pixels, gsf__nn_chunk_rows(b->candidates * b->channels)), gsf__blend_grad_chunk,
                      b);
}

// ---- training: parameters and AdamW

typedef struct gsf__nn_params { // the trained tensors of a network in float32; destroy them before the network
    gsf_nn_weights* weights;
    gsf_nn_tensor* stored;      // the network's tensors as they were in the file
    int64_t* at;                // per tensor: offset of its values below; -1: not trained
    int64_t count, step;        // values; updates done
    float *value, *grad, *m, *v; // (count); value: what the network computes with; m, v: Adam's moments
    float* average;             // (count): moving average of the values; NULL: none
} gsf__nn_params;

static void gsf__nn_destroy_params(gsf_context* ctx, gsf__nn_params* params) {
    if (params->stored)
        memcpy(params->weights->tensors, params->stored, params->weights->tensor_count * sizeof *params->stored);
    gsf_free(ctx, params->stored);
    gsf_free(ctx, params->at);
    gsf_free(ctx, params->value);
    memset(params, 0, sizeof *params);
}

// Makes a network compute with float32 copies of the tensors that `trains` accepts by name (NULL: all).
GSF__SHARED gsf_result gsf__nn_make_params(gsf_context* ctx, gsf_nn_weights* weights, int (*trains)(const char* name),
                                           int average, gsf__nn_params* out) {
    const size_t tensors = weights->tensor_count;
    memset(out, 0, sizeof *out);
    out->weights = weights;
    out->at = (int64_t*)gsf_alloc(ctx, tensors, sizeof *out->at);
    if (!out->at) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < tensors; i++) {
        out->at[i] = !trains || trains(weights->tensors[i].name) ? out->count : -1;
        if (out->at[i] >= 0) out->count += weights->tensors[i].count;
    }
    out->value = (float*)gsf_alloc_zeroed(ctx, (size_t)out->count, (average ? 5 : 4) * sizeof(float));
    gsf_nn_tensor* stored = out->value ? (gsf_nn_tensor*)gsf_alloc(ctx, tensors, sizeof *stored) : NULL;
    if (!stored) {
        gsf__nn_destroy_params(ctx, out);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    memcpy(stored, weights->tensors, tensors * sizeof *stored);
    out->stored = stored;
    out->grad = out->value + out->count;
    out->m = out->grad + out->count;
    out->v = out->m + out->count;
    out->average = average ? out->v + out->count : NULL;
    for (size_t i = 0; i < tensors; i++) {
        if (out->at[i] < 0) continue;
        gsf_nn_convert_tensor(&stored[i], 0, stored[i].count, out->value + out->at[i]);
        weights->tensors[i].data = out->value + out->at[i];
        weights->tensors[i].dtype = GSF_NN_F32;
    }
    if (average) memcpy(out->average, out->value, (size_t)out->count * sizeof(float));
    return GSF_OK;
}

// Where to add the gradient of a tensor; NULL if there is no such tensor or it is not trained.
static float* gsf__nn_grad_of(const gsf__nn_params* params, const gsf_nn_tensor* tensor) {
    const int64_t at = tensor ? params->at[tensor - params->weights->tensors] : -1;
    return at < 0 ? NULL : params->grad + at;
}

typedef struct gsf__nn_adam_desc { // zero is the default
    double lr;                // 0: 2e-5, the paper's
    double beta1, beta2, eps; // 0: 0.9, 0.999, 1e-8
    double weight_decay;      // decoupled (Loshchilov and Hutter 2019)
    double max_norm;          // of all gradients together, which are scaled down to it; 0: any
    double average;           // decay of the moving average, as 0.9999
    int64_t warmup;           // steps in which the rate rises, from 0 in the first one
    int64_t steps;            // step at which the rate, falling as half a cosine from the warm-up on, is 0; 0: constant
    int64_t batches;          // whose gradients have been added up, to take their mean; 0: 1
} gsf__nn_adam_desc;

static double gsf__nn_adam_rate(const gsf__nn_adam_desc* d, int64_t step) { // step counts from 0
    const double lr = d->lr != 0.0 ? d->lr : 2e-5;
    if (step < d->warmup) return lr * (double)step / (double)d->warmup;
    if (!d->steps) return lr;
    if (step >= d->steps) return 0.0;
    return lr * 0.5 * (1.0 + cos(3.141592653589793 * (double)(step - d->warmup) / (double)(d->steps - d->warmup)));
}

typedef struct gsf__nn_adam_job {
    const gsf__grad_kernels* kernels;
    const gsf__norm_kernels* norms;
    gsf__nn_params* params;
    gsf__adam_terms terms;
    int64_t part;             // values per part
    double squares[GSF__GRAD_PARTS];
} gsf__nn_adam_job;

static void gsf__adam_square_part(void* arg, size_t part, int32_t worker) {
    gsf__nn_adam_job* job = (gsf__nn_adam_job*)arg;
    const int64_t begin = (int64_t)part * job->part, count = gsf__least(job->part, job->params->count - begin);
    (void)worker;
    job->squares[part] = job->norms->moments(job->params->grad + begin, count, 0).square;
}

static void gsf__nn_adam_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__nn_adam_job* job = (const gsf__nn_adam_job*)arg;
    const gsf__nn_params* p = job->params;
    const int64_t at = (int64_t)chunk * GSF__NN_CHUNK, count = gsf__least(GSF__NN_CHUNK, p->count - at);
    (void)worker;
    job->kernels->adam(&job->terms, count, p->grad + at, p->m + at, p->v + at, p->value + at,
                       p->average ? p->average + at : NULL);
}

// One update by AdamW, then the gradients are zero. norm (may be NULL) receives the gradients' before clipping; if it is not
// finite, nothing is updated.
GSF__SHARED gsf_result gsf__nn_step_adam(gsf_context* ctx, gsf__nn_params* params, const gsf__nn_adam_desc* d, double* norm) {
    const double beta1 = d->beta1 != 0.0 ? d->beta1 : 0.9, beta2 = d->beta2 != 0.0 ? d->beta2 : 0.999;
    const double mean = d->batches > 1 ? 1.0 / (double)d->batches : 1.0, rate = gsf__nn_adam_rate(d, params->step);
    gsf__nn_adam_job job;
    double square = 0.0;
    memset(&job, 0, sizeof job);
    job.kernels = gsf__grad_kernels_of(ctx->cpu_level);
    job.norms = gsf__norm_kernels_of(ctx->cpu_level);
    job.params = params;
    job.part = gsf__ceil_div(params->count, GSF__GRAD_PARTS);
    const size_t parts = gsf__nn_chunks(params->count, job.part > 0 ? job.part : 1);
    gsf__parallel_for(ctx, parts, gsf__adam_square_part, &job);
    for (size_t i = 0; i < parts; i++) square += job.squares[i];
    const double size = sqrt(square) * mean;
    if (norm) *norm = size;
    if (!(size <= DBL_MAX))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "training: gradients of step %lld are not finite", (long long)params->step);
    const double clip = d->max_norm != 0.0 && size + 1e-6 > d->max_norm ? d->max_norm / (size + 1e-6) : 1.0; // as PyTorch
    const double t = (double)++params->step;
    job.terms.scale = (float)(mean * clip);
    job.terms.beta1 = (float)beta1;
    job.terms.beta2 = (float)beta2;
    job.terms.rest1 = (float)(1.0 - beta1);
    job.terms.rest2 = (float)(1.0 - beta2);
    job.terms.decay = (float)(1.0 - rate * d->weight_decay);
    job.terms.rate = (float)(rate / (1.0 - pow(beta1, t)));
    job.terms.root = (float)(1.0 / sqrt(1.0 - pow(beta2, t)));
    job.terms.eps = (float)(d->eps != 0.0 ? d->eps : 1e-8);
    job.terms.average = (float)(1.0 - d->average);
    gsf__parallel_for(ctx, gsf__nn_chunks(params->count, GSF__NN_CHUNK), gsf__nn_adam_chunk, &job);
    return GSF_OK;
}

// ---- training: parameters in files

/* The network's tensors under their own names, trained ones in float32; for a later resume also Adam's moments and the
   moving average, as optimizer.m.NAME, optimizer.v.NAME, average.NAME and optimizer.step. */
typedef enum gsf__nn_saved { GSF__NN_SAVE_VALUES = 0, GSF__NN_SAVE_AVERAGE, GSF__NN_SAVE_STATE } gsf__nn_saved;

static const char* const gsf__nn_state_names[4] = {"", "optimizer.m.", "optimizer.v.", "average."};

enum { GSF__NN_STATE_NAME = 16 }; // more than the longest of them

static float* gsf__nn_state_of(const gsf__nn_params* p, int kind) {
    return kind == 0 ? p->value : kind == 1 ? p->m : kind == 2 ? p->v : p->average;
}

// what AVERAGE: the moving average in the place of the values, to use the network with
GSF__SHARED gsf_result gsf__nn_save_params(gsf_context* ctx, const gsf__nn_params* params, gsf__nn_saved what,
                                           const char* path) {
    const size_t tensors = params->weights->tensor_count;
    const int kinds = what != GSF__NN_SAVE_STATE ? 1 : params->average ? 4 : 3;
    size_t names = 0, used = 0, count = 0;
    if (what == GSF__NN_SAVE_AVERAGE && !params->average)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: there is no moving average to save", path);
    for (size_t i = 0; i < tensors; i++) names += 4 * (strlen(params->weights->tensors[i].name) + GSF__NN_STATE_NAME);
    gsf_nn_tensor* all = (gsf_nn_tensor*)gsf_alloc_zeroed(ctx, 4 * tensors + 1, sizeof *all);
    char* text = all ? (char*)gsf_alloc(ctx, names + 1, 1) : NULL;
    if (!text) {
        gsf_free(ctx, all);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    for (int kind = 0; kind < kinds; kind++)
        for (size_t i = 0; i < tensors; i++) {
            const float* from = what == GSF__NN_SAVE_AVERAGE ? params->average : gsf__nn_state_of(params, kind);
            if (kind && params->at[i] < 0) continue;
            gsf_nn_tensor* t = &all[count++];
            *t = params->weights->tensors[i];
            if (params->at[i] >= 0) t->data = from + params->at[i];
            t->name = text + used;
            used += 1 + (size_t)snprintf(text + used, names + 1 - used, "%s%s", gsf__nn_state_names[kind],
                                         params->weights->tensors[i].name);
        }
    if (what == GSF__NN_SAVE_STATE) {
        gsf_nn_tensor* t = &all[count++];
        t->name = "optimizer.step";
        t->data = &params->step;
        t->dtype = GSF_NN_I64;
        t->count = 1;
    }
    const gsf_result result = gsf_nn_save_tensors(ctx, path, all, count);
    gsf_free(ctx, text);
    gsf_free(ctx, all);
    return result;
}

static gsf_result gsf__nn_read_state(gsf_context* ctx, const gsf_nn_weights* file, gsf__nn_params* params, int copy) {
    for (int kind = 0; kind < (params->average ? 4 : 3); kind++)
        for (size_t i = 0; i < params->weights->tensor_count; i++) {
            const gsf_nn_tensor* mine = &params->weights->tensors[i];
            char name[512];
            if (params->at[i] < 0) continue;
            snprintf(name, sizeof name, "%s%s", gsf__nn_state_names[kind], mine->name);
            const gsf_nn_tensor* t = gsf_nn_find_tensor(file, name);
            if (!t || t->dtype != GSF_NN_F32 || t->rank != mine->rank ||
                memcmp(t->shape, mine->shape, sizeof t->shape) != 0)
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: tensor %s is %s", file->name, name,
                                t ? "not float32 of the network's shape" : "missing");
            if (copy) gsf_nn_convert_tensor(t, 0, t->count, gsf__nn_state_of(params, kind) + params->at[i]);
        }
    return GSF_OK;
}

// Continues from a file saved with STATE: the same bits as without the interruption. On error nothing is changed.
GSF__SHARED gsf_result gsf__nn_load_params(gsf_context* ctx, gsf__nn_params* params, const char* path) {
    gsf_nn_weights file;
    int64_t count = 0;
    GSF__TRY(gsf_nn_load_weights(ctx, path, NULL, &file));
    const gsf_nn_tensor* step = gsf_nn_find_tensor(&file, "optimizer.step");
    gsf_result result = GSF_OK;
    if (step && step->dtype == GSF_NN_I64 && step->count == 1) memcpy(&count, step->data, sizeof count);
    else count = -1;
    if (count < 0) result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: tensor optimizer.step is missing or no step", file.name);
    if (!result) result = gsf__nn_read_state(ctx, &file, params, 0);
    if (!result) result = gsf__nn_read_state(ctx, &file, params, 1);
    if (!result) {
        params->step = count;
        memset(params->grad, 0, (size_t)params->count * sizeof(float));
    }
    gsf_nn_destroy_weights(ctx, &file);
    return result;
}

// ---- training: the transformer

/* Gradients of gsf_nn_run_transformer, one sample at a time. The forward pass keeps the input of every block; the backward
   pass runs a block again, keeping its intermediates, and then backwards. So the memory is that of one block plus one
   (tokens, width) per block. Names: d* is the gradient of *. */

typedef struct gsf__dit_trace { // intermediates of one block; (tokens, width) unless noted, q, k: before their norms
    float *m1, *m2;                        // (6 width): modulation
    float *n1, *q, *k, *v, *qn, *kn, *attended, *b1, *x1; // b1: the attention's result before the gate
    float *nc, *cq, *ck, *cv, *cqn, *ckn, *looked; // cross attention: of video, ck, cv, ckn: (reference tokens, width)
    float *n2, *up, *hidden, *b2, *x2;      // up, hidden: (tokens, 4 width)
    float *lse, *cross_lse;                 // (heads, tokens), (heads, video)
} gsf__dit_trace;

typedef struct gsf__dit_train {
    gsf__dit_run run;          // of one sample
    gsf__nn_params* params;
    const float *dino, *vggt;  // the sample's reference tokens, before the projection
    float* inputs;             // (layers + 1, tokens, width): x before each block and after the last
    float* references;         // (reference tokens, width)
    gsf__dit_trace kept;
    float *dx, *dn, *db, *dq, *dk, *dv; // (rows, width), rows: the larger of tokens and reference tokens
    float *dhidden;            // (tokens, 4 width)
    float *dm, *dtime, *dreferences;
    float* patches;            // (video, outputs or inputs of a token)
    float* out;                // predicted velocity, then the noisy input with control, then the true velocity
    float *wave, *time1, *time2, *hidden_time; // of the time embedding; time1, time2: before the activations
} gsf__dit_train;

static gsf_result gsf__dit_linear_grad(const gsf__dit_train* t, const gsf__nn_layer* layer, const float* x, int64_t rows,
                                       const float* dy, float* dx, int accumulate) {
    gsf__nn_linear_grad_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.rows = rows;
    d.weight = layer->weight;
    d.dy = dy;
    d.dx = dx;
    d.accumulate = accumulate;
    d.dweight = gsf__nn_grad_of(t->params, layer->weight);
    d.dbias = gsf__nn_grad_of(t->params, layer->bias);
    return dx || d.dweight || d.dbias ? gsf__nn_linear_grad(t->run.nn.ctx, &d) : GSF_OK;
}

// scale, dscale, dshift NULL: a norm without modulation
static gsf_result gsf__dit_norm_grad(gsf__dit_train* t, const gsf__nn_layer* layer, float eps, const float* x, int64_t rows,
                                     const float* scale, float* dscale, float* dshift, const float* dy, float* dx,
                                     int accumulate) {
    const gsf__nn_vectors v = gsf__nn_widen_layer(&t->run.nn, layer);
    gsf__nn_norm_grad_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.rows = rows;
    d.dim = t->run.width;
    d.by.weight = v.weight;
    d.by.bias = v.bias;
    d.by.scale = scale;
    d.eps = eps;
    d.dy = dy;
    d.dx = dx;
    d.accumulate = accumulate;
    d.dweight = gsf__nn_grad_of(t->params, layer->weight);
    d.dbias = gsf__nn_grad_of(t->params, layer->bias);
    d.dscale = dscale;
    d.dshift = dshift;
    return gsf__nn_norm_grad(t->run.nn.ctx, &d);
}

static gsf_result gsf__dit_head_grad(gsf__dit_train* t, const gsf__nn_layer* norm, int rotate, const float* x, int64_t rows,
                                     float* dx) { // in place
    const gsf_nn_transformer* c = t->run.net;
    const gsf__nn_vectors v = gsf__nn_widen_layer(&t->run.nn, norm);
    const gsf__nn_head_grad_desc d = {
        x, rows, rotate ? t->run.text : 0, c->heads, c->head_dim, v.weight, rotate ? t->run.cos : NULL,
        rotate ? t->run.sin : NULL, 1e-6f, dx, dx, gsf__nn_grad_of(t->params, norm->weight),
        gsf__nn_grad_of(t->params, norm->bias)};
    return gsf__nn_head_grad(t->run.nn.ctx, &d);
}

static gsf__nn_attention_desc gsf__dit_attention_of(const gsf__dit_run* run, int64_t queries, int64_t keys, const float* q,
                                                    const float* k, const float* v, float* out, float* lse) {
    gsf__nn_attention_desc a;
    memset(&a, 0, sizeof a);
    a.queries = queries;
    a.keys = keys;
    a.heads = run->net->heads;
    a.head_dim = run->net->head_dim;
    a.q = q;
    a.k = k;
    a.v = v;
    a.out = out;
    a.lse = lse;
    return a;
}

// ---- transformer: a block again, keeping its intermediates

static gsf_result gsf__dit_trace_modulated(gsf__dit_train* t, const gsf__dit_norm* norm, float* x, float* m, float* n) {
    gsf__dit_run* run = &t->run;
    float* const before = run->x;
    run->x = x; // normalises to run->normed
    const gsf_result result = gsf__dit_modulate(run, "", 0, norm);
    run->x = before;
    memcpy(m, run->modulation, (size_t)(6 * run->width) * sizeof(float));
    memcpy(n, run->normed, (size_t)(run->tokens * run->width) * sizeof(float));
    return result;
}

// Linear layers and head norms of q or k.
static gsf_result gsf__dit_trace_projected(gsf__dit_train* t, const gsf__nn_layer* layer, const gsf__nn_layer* norm, int rotate,
                                          const float* x, int64_t rows, float* y, float* yn) {
    GSF__TRY(gsf__dit_linear(&t->run, layer, x, rows, y));
    memcpy(yn, y, (size_t)(rows * t->run.width) * sizeof(float));
    gsf__dit_norm_heads(&t->run, norm, rotate, yn, rows);
    return GSF_OK;
}

// y = x + gate * b, with the gates of the text and video tokens
static void gsf__dit_add_gated(const gsf__dit_run* run, const float* x, const float* m, const float* b, float* y) {
    const int64_t d = run->width;
    for (int64_t r = 0; r < run->tokens; r++) {
        const float* gate = m + (r < run->text ? GSF__DIT_TEXT_GATE : GSF__DIT_VIDEO_GATE) * d;
        for (int64_t i = 0; i < d; i++) y[r * d + i] = x[r * d + i] + gate[i] * b[r * d + i];
    }
}

static gsf_result gsf__dit_trace_block(gsf__dit_train* t, const gsf__dit_block* block, float* x) {
    gsf__dit_run* run = &t->run;
    gsf__dit_trace* s = &t->kept;
    gsf_context* ctx = run->nn.ctx;
    const int64_t n = run->tokens, d = run->width, text = run->text * d, r = run->in->reference_tokens;
    gsf__nn_attention_desc a = gsf__dit_attention_of(run, n, n, s->qn, s->kn, s->v, s->attended, s->lse);
    GSF__TRY(gsf__dit_trace_modulated(t, &block->norm1, x, s->m1, s->n1));
    GSF__TRY(gsf__dit_trace_projected(t, &block->self.q, &block->self.norm_q, 1, s->n1, n, s->q, s->qn));
    GSF__TRY(gsf__dit_trace_projected(t, &block->self.k, &block->self.norm_k, 1, s->n1, n, s->k, s->kn));
    GSF__TRY(gsf__dit_linear(run, &block->self.v, s->n1, n, s->v));
    GSF__TRY(gsf__nn_run_attention(ctx, &run->nn.workspace, &a));
    GSF__TRY(gsf__dit_linear(run, &block->self.out, s->attended, n, s->b1));
    gsf__dit_add_gated(run, x, s->m1, s->b1, s->x1);
    memcpy(s->x2, s->x1, (size_t)(n * d) * sizeof(float));
    if (r > 0) {
        a = gsf__dit_attention_of(run, run->video, r, s->cqn, s->ckn, s->cv, s->looked, s->cross_lse);
        gsf__nn_norm(&run->nn, &block->norm_cross, (float)run->net->norm_eps, s->x1 + text, run->video, s->nc);
        GSF__TRY(gsf__dit_trace_projected(t, &block->cross.q, &block->cross.norm_q, 0, s->nc, run->video, s->cq, s->cqn));
        GSF__TRY(gsf__dit_trace_projected(t, &block->cross.k, &block->cross.norm_k, 0, t->references, r, s->ck, s->ckn));
        GSF__TRY(gsf__dit_linear(run, &block->cross.v, t->references, r, s->cv));
        GSF__TRY(gsf__nn_run_attention(ctx, &run->nn.workspace, &a));
        GSF__TRY(gsf__nn_add(&run->nn, &block->cross.out, NULL, s->looked, run->video, s->x2 + text));
    }
    GSF__TRY(gsf__dit_trace_modulated(t, &block->norm2, s->x2, s->m2, s->n2));
    GSF__TRY(gsf__dit_linear(run, &block->up, s->n2, n, s->up));
    gsf__nn_activate(ctx, GSF__NN_GELU_TANH, s->up, 4 * n * d, s->hidden);
    return gsf__dit_linear(run, &block->down, s->hidden, n, s->b2);
}

// ---- transformer: backwards

// x3 = x + gate * b: db = gate * dx; adds to the gates' gradients.
static gsf_result gsf__dit_gates_grad(gsf__dit_train* t, const float* m, const float* b) {
    const gsf__dit_run* run = &t->run;
    const int64_t d = run->width, at = run->text * d;
    GSF__TRY(gsf__nn_gate_grad(run->nn.ctx, m + GSF__DIT_TEXT_GATE * d, b, t->dx, run->text, d, t->db,
                               t->dm + GSF__DIT_TEXT_GATE * d));
    return gsf__nn_gate_grad(run->nn.ctx, m + GSF__DIT_VIDEO_GATE * d, b + at, t->dx + at, run->video, d, t->db + at,
                             t->dm + GSF__DIT_VIDEO_GATE * d);
}

// dx += the gradient of the modulated norm of x; then that of the modulation, of which t->dm has the gates already.
static gsf_result gsf__dit_modulate_grad(gsf__dit_train* t, const gsf__dit_norm* norm, const float* x, const float* m) {
    const gsf__dit_run* run = &t->run;
    const int64_t d = run->width, at = run->text * d;
    const float eps = (float)run->net->norm_eps;
    float* dm = t->dm;
    GSF__TRY(gsf__dit_norm_grad(t, &norm->norm, eps, x, run->text, m + 4 * d, dm + 4 * d, dm + 3 * d, t->dn, t->dx, 1));
    GSF__TRY(gsf__dit_norm_grad(t, &norm->norm, eps, x + at, run->video, m + d, dm + d, dm, t->dn + at, t->dx + at, 1));
    return gsf__dit_linear_grad(t, &norm->linear, run->time, 1, dm, t->dtime, 1);
}

static gsf_result gsf__dit_attention_grad(gsf__dit_train* t, const gsf__nn_attention_desc* a, const float* dy) {
    const gsf__nn_attention_grad_desc d = {a, dy, t->dq, t->dk, t->dv};
    return gsf__nn_attention_grad(t->run.nn.ctx, &d);
}

static gsf_result gsf__dit_block_backward(gsf__dit_train* t, const gsf__dit_block* block, const float* x) {
    const gsf__dit_run* run = &t->run;
    const gsf__dit_trace* s = &t->kept;
    const int64_t n = run->tokens, d = run->width, text = run->text * d, r = run->in->reference_tokens;
    memset(t->dm, 0, (size_t)(6 * d) * sizeof(float));
    GSF__TRY(gsf__dit_gates_grad(t, s->m2, s->b2));
    GSF__TRY(gsf__dit_linear_grad(t, &block->down, s->hidden, n, t->db, t->dhidden, 0));
    gsf__nn_activate_grad(run->nn.ctx, GSF__NN_GELU_TANH, s->up, t->dhidden, 4 * n * d, t->dhidden);
    GSF__TRY(gsf__dit_linear_grad(t, &block->up, s->n2, n, t->dhidden, t->dn, 0));
    GSF__TRY(gsf__dit_modulate_grad(t, &block->norm2, s->x2, s->m2));
    if (r > 0) {
        const gsf__nn_attention_desc a =
            gsf__dit_attention_of(run, run->video, r, s->cqn, s->ckn, s->cv, s->looked, s->cross_lse);
        GSF__TRY(gsf__dit_linear_grad(t, &block->cross.out, s->looked, run->video, t->dx + text, t->db, 0));
        GSF__TRY(gsf__dit_attention_grad(t, &a, t->db));
        GSF__TRY(gsf__dit_head_grad(t, &block->cross.norm_q, 0, s->cq, run->video, t->dq));
        GSF__TRY(gsf__dit_head_grad(t, &block->cross.norm_k, 0, s->ck, r, t->dk));
        GSF__TRY(gsf__dit_linear_grad(t, &block->cross.q, s->nc, run->video, t->dq, t->dn, 0));
        GSF__TRY(gsf__dit_linear_grad(t, &block->cross.k, t->references, r, t->dk, t->dreferences, 1));
        GSF__TRY(gsf__dit_linear_grad(t, &block->cross.v, t->references, r, t->dv, t->dreferences, 1));
        GSF__TRY(gsf__dit_norm_grad(t, &block->norm_cross, (float)run->net->norm_eps, s->x1 + text, run->video, NULL, NULL,
                                    NULL, t->dn, t->dx + text, 1));
    }
    const gsf__nn_attention_desc a = gsf__dit_attention_of(run, n, n, s->qn, s->kn, s->v, s->attended, s->lse);
    memset(t->dm, 0, (size_t)(6 * d) * sizeof(float));
    GSF__TRY(gsf__dit_gates_grad(t, s->m1, s->b1));
    GSF__TRY(gsf__dit_linear_grad(t, &block->self.out, s->attended, n, t->db, t->dn, 0));
    GSF__TRY(gsf__dit_attention_grad(t, &a, t->dn));
    GSF__TRY(gsf__dit_head_grad(t, &block->self.norm_q, 1, s->q, n, t->dq));
    GSF__TRY(gsf__dit_head_grad(t, &block->self.norm_k, 1, s->k, n, t->dk));
    GSF__TRY(gsf__dit_linear_grad(t, &block->self.q, s->n1, n, t->dq, t->dn, 0));
    GSF__TRY(gsf__dit_linear_grad(t, &block->self.k, s->n1, n, t->dk, t->dn, 1));
    GSF__TRY(gsf__dit_linear_grad(t, &block->self.v, s->n1, n, t->dv, t->dn, 1));
    return gsf__dit_modulate_grad(t, &block->norm1, x, s->m1);
}

// From dout (frames, channels, height, width) to t->dx, the gradient of what the last block returns.
static gsf_result gsf__dit_output_grad(gsf__dit_train* t, const float* x, const float* dout) {
    gsf__dit_run* run = &t->run;
    const gsf_nn_transformer* c = run->net;
    const gsf__dit_norm* norm = &run->nets->norm_out;
    const int64_t d = run->width, at = run->text * d;
    const float eps = (float)c->norm_eps;
    float *m = run->modulation, *normed = t->kept.n1, *modulated = t->kept.n2;
    const gsf__nn_patch_job job = {dout, t->patches, c->out_channels, run->in->height, run->in->width, c->patch, 0, NULL,
                                   NULL};
    gsf__nn_patch(run->nn.ctx, &job, run->in->frames);
    gsf__nn_norm(&run->nn, &run->nets->norm_final, eps, x + at, run->video, normed);
    GSF__TRY(gsf__dit_linear(run, &norm->linear, run->time, 1, m));
    const gsf__nn_vectors v = gsf__nn_widen_layer(&run->nn, &norm->norm);
    gsf__nn_layer_norm_modulated(run->nn.ctx, normed, run->video, d, v.weight, v.bias, eps, m + d, m, modulated);
    memset(t->dm, 0, (size_t)(6 * d) * sizeof(float));
    memset(t->dx, 0, (size_t)at * sizeof(float));
    GSF__TRY(gsf__dit_linear_grad(t, &run->nets->out, modulated, run->video, t->patches, t->db, 0));
    GSF__TRY(gsf__dit_norm_grad(t, &norm->norm, eps, normed, run->video, m + d, t->dm + d, t->dm, t->db, t->dn, 0));
    GSF__TRY(gsf__dit_linear_grad(t, &norm->linear, run->time, 1, t->dm, t->dtime, 1));
    return gsf__dit_norm_grad(t, &run->nets->norm_final, eps, x + at, run->video, NULL, NULL, NULL, t->dn, t->dx + at, 0);
}

// Layers that come before the blocks, from t->dx, dtime and dreferences on.
static gsf_result gsf__dit_input_grad(gsf__dit_train* t) {
    gsf__dit_run* run = &t->run;
    const gsf_nn_transformer* c = run->net;
    const gsf__dit_nets* nets = run->nets;
    const int64_t d = run->width, time = c->time_channels, r = run->in->reference_tokens;
    const gsf__nn_patch_job job = {run->in->hidden, t->patches, c->in_channels, run->in->height, run->in->width, c->patch, 0,
                                   NULL, NULL};
    gsf__nn_patch(run->nn.ctx, &job, run->in->frames);
    GSF__TRY(gsf__dit_linear_grad(t, &nets->patch, t->patches, run->video, t->dx + run->text * d, NULL, 0));
    GSF__TRY(gsf__dit_linear_grad(t, &nets->text, run->in->text, run->text, t->dx, NULL, 0));
    gsf__nn_embed_timestep(run->in->timesteps[0], (int32_t)d, t->wave);
    GSF__TRY(gsf__dit_linear(run, &nets->time1, t->wave, 1, t->time1));
    float* hidden = t->hidden_time;
    gsf__nn_activate(run->nn.ctx, GSF__NN_SILU, t->time1, time, hidden);
    GSF__TRY(gsf__dit_linear(run, &nets->time2, hidden, 1, t->time2));
    gsf__nn_activate_grad(run->nn.ctx, GSF__NN_SILU, t->time2, t->dtime, time, t->dtime);
    GSF__TRY(gsf__dit_linear_grad(t, &nets->time2, hidden, 1, t->dtime, t->time2, 0));
    gsf__nn_activate_grad(run->nn.ctx, GSF__NN_SILU, t->time1, t->time2, time, t->time2);
    GSF__TRY(gsf__dit_linear_grad(t, &nets->time1, t->wave, 1, t->time2, NULL, 0));
    const struct { const gsf__dit_projector* by; const float* from; } parts[2] = {{&nets->dino, t->dino},
                                                                                 {&nets->vggt, t->vggt}};
    for (int i = 0; i < 2 && r > 0; i++) {
        if (!parts[i].from) continue;
        GSF__TRY(gsf__dit_linear(run, &parts[i].by->linear, parts[i].from, r, t->dk));
        GSF__TRY(gsf__dit_norm_grad(t, &parts[i].by->norm, 1e-5f, t->dk, r, NULL, NULL, NULL, t->dreferences, t->dn, 0));
        GSF__TRY(gsf__dit_linear_grad(t, &parts[i].by->linear, parts[i].from, r, t->dn, NULL, 0));
    }
    return GSF_OK;
}

// ---- transformer: a training step

typedef struct gsf__dit_example { // what one training example is made of
    const float *latents, *noise; // (frames, out_channels, height, width)
    const float* control;         // the same with the other in_channels - out_channels channels
    const float* text;            // (text tokens, text_channels)
    const float *dino, *vggt;     // (reference_tokens, dino_channels or vggt_channels); may both be NULL
    int64_t reference_tokens;
    int32_t timestep;             // 0 .. train_steps - 1
} gsf__dit_example;

typedef struct gsf__dit_train_desc {
    int32_t frames, height, width; // of the latents
    int32_t batch;                // examples whose losses are averaged
    const gsf__dit_example* examples;
    const gsf_nn_schedule* schedule;
    float* predicted;             // NULL, or (batch, frames, out_channels, height, width): for tests
} gsf__dit_train_desc;

GSF__SHARED int gsf__dit_trains(const char* name) { return strcmp(name, "patch_embed.pos_embedding") != 0; } // it is a buffer

// Divides the memory of a step; returns the floats needed.
static size_t gsf__dit_lay_out_train(gsf__dit_train* t, float* memory) {
    const gsf_nn_transformer* c = t->run.net;
    const size_t forward = gsf__dit_lay_out(&t->run, memory), d = (size_t)t->run.width, n = (size_t)t->run.tokens;
    const size_t r = (size_t)t->run.in->reference_tokens, rows = gsf__nn_larger(n, r), video = (size_t)t->run.video;
    const size_t channels = (size_t)(c->in_channels > c->out_channels ? c->in_channels : c->out_channels);
    gsf__nn_arena arena = {memory, forward};
    gsf__dit_trace* s = &t->kept;
    float** const whole[] = {&s->n1, &s->q, &s->k, &s->v, &s->qn, &s->kn, &s->attended, &s->b1, &s->x1, &s->nc, &s->cq,
                             &s->cqn, &s->looked, &s->n2, &s->b2, &s->x2, &t->dx};
    float** const larger[] = {&s->ck, &s->cv, &s->ckn, &t->dn, &t->db, &t->dq, &t->dk, &t->dv, &t->references,
                              &t->dreferences};
    for (size_t i = 0; i < GSF__COUNT(whole); i++) *whole[i] = gsf__nn_share(&arena, n * d);
    for (size_t i = 0; i < GSF__COUNT(larger); i++) *larger[i] = gsf__nn_share(&arena, rows * d);
    s->up = gsf__nn_share(&arena, 4 * n * d);
    s->hidden = gsf__nn_share(&arena, 4 * n * d);
    t->dhidden = gsf__nn_share(&arena, 4 * n * d);
    s->lse = gsf__nn_share(&arena, (size_t)c->heads * n);
    s->cross_lse = gsf__nn_share(&arena, (size_t)c->heads * video);
    s->m1 = gsf__nn_share(&arena, 6 * d);
    s->m2 = gsf__nn_share(&arena, 6 * d);
    t->dm = gsf__nn_share(&arena, 6 * d);
    t->inputs = gsf__nn_share(&arena, gsf__nn_product((size_t)c->layers + 1, n * d));
    t->patches = gsf__nn_share(&arena, video * (size_t)c->patch * (size_t)c->patch * channels);
    t->out = gsf__nn_share(&arena, 3 * video * (size_t)c->patch * (size_t)c->patch * channels);
    t->wave = gsf__nn_share(&arena, d);
    t->dtime = gsf__nn_share(&arena, (size_t)c->time_channels);
    t->time1 = gsf__nn_share(&arena, (size_t)c->time_channels);
    t->time2 = gsf__nn_share(&arena, (size_t)c->time_channels);
    t->hidden_time = gsf__nn_share(&arena, (size_t)c->time_channels);
    return arena.used;
}

// Noisy latents and control, frame by frame the channels of both.
static void gsf__dit_join_input(const gsf__dit_train* t, const float* noisy, const float* control, float* hidden) {
    const gsf_nn_transformer* c = t->run.net;
    const size_t plane = (size_t)t->run.in->height * (size_t)t->run.in->width;
    const size_t first = (size_t)c->out_channels * plane, second = (size_t)c->in_channels * plane - first;
    for (int32_t f = 0; f < t->run.in->frames; f++, hidden += first + second) {
        memcpy(hidden, noisy + (size_t)f * first, first * sizeof(float));
        memcpy(hidden + first, control + (size_t)f * second, second * sizeof(float));
    }
}

// Adds an example's squared error to *loss and its gradients, both times `share`.
static gsf_result gsf__dit_train_example(gsf__dit_train* t, const gsf__dit_train_desc* desc, const gsf__dit_example* e,
                                         double share, float* predicted, double* loss) {
    gsf__dit_run* run = &t->run;
    gsf_context* ctx = run->nn.ctx;
    const gsf_nn_transformer* c = run->net;
    const size_t count = (size_t)desc->frames * (size_t)c->out_channels * (size_t)desc->height * (size_t)desc->width;
    const size_t rows = (size_t)(run->tokens * run->width);
    const size_t pixels = count / (size_t)c->out_channels;
    float *out = t->out, *hidden = out + count, *target = hidden + pixels * (size_t)c->in_channels;
    double sum = 0.0;
    gsf__nn_add_noise(ctx, desc->schedule, e->timestep, e->latents, e->noise, count, target);
    gsf__dit_join_input(t, target, e->control, hidden);
    t->dino = e->dino;
    t->vggt = e->vggt;
    if (e->reference_tokens)
        GSF__TRY(gsf_nn_project_references(ctx, c, e->reference_tokens, e->dino, e->vggt, t->references));
    GSF__TRY(gsf__dit_embed_time(run));
    GSF__TRY(gsf__dit_embed(run));
    for (int32_t i = 0; i < c->layers; i++) {
        memcpy(t->inputs + (size_t)i * rows, run->x, rows * sizeof(float));
        GSF__TRY(gsf__dit_block_forward(run, i));
    }
    memcpy(t->inputs + (size_t)c->layers * rows, run->x, rows * sizeof(float));
    GSF__TRY(gsf__dit_head(run, 0, out));
    GSF__TRY(gsf__nn_check(&run->nn, "the output layer", "proj_out.", out, (int64_t)count));
    if (predicted) memcpy(predicted, out, count * sizeof(float));
    gsf__nn_make_velocity(ctx, desc->schedule, e->timestep, e->latents, e->noise, count, target);
    for (size_t i = 0; i < count; i++) {
        const double error = (double)out[i] - (double)target[i];
        sum += error * error;
        out[i] = (float)(2.0 * share * error);
    }
    *loss += share * sum;
    memset(t->dtime, 0, (size_t)c->time_channels * sizeof(float));
    memset(t->dreferences, 0, (size_t)(e->reference_tokens * run->width) * sizeof(float));
    GSF__TRY(gsf__dit_output_grad(t, t->inputs + (size_t)c->layers * rows, out));
    for (int32_t i = c->layers - 1; i >= 0; i--) {
        float* x = t->inputs + (size_t)i * rows;
        GSF__TRY(gsf__dit_trace_block(t, &run->nets->blocks[i], x));
        GSF__TRY(gsf__dit_block_backward(t, &run->nets->blocks[i], x));
        GSF__TRY(gsf__check_cancel(ctx));
    }
    return gsf__dit_input_grad(t);
}

static gsf_result gsf__dit_check_training(gsf_context* ctx, const gsf_nn_transformer* c, const gsf__dit_train_desc* desc) {
    const gsf__dit_nets* nets = (const gsf__dit_nets*)c->nets;
    if (nets->quantized) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "training: the transformer has 8-bit layers");
    if (c->bf16) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "training: bf16 products are not supported");
    for (int32_t b = 0; b < desc->batch; b++) {
        const gsf__dit_example* e = &desc->examples[b];
        if (!e->latents || !e->control || !e->noise || !e->text || e->timestep < 0 ||
            e->timestep >= desc->schedule->desc.train_steps || (e->reference_tokens > 0) != (e->dino || e->vggt))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "training: example %d lacks an input or has time step %d", (int)b,
                            (int)e->timestep);
    }
    return GSF_OK;
}

// Adds the gradients of a batch to params->grad, made of the transformer's weights; loss: the mean squared error of the
// predicted velocities.
GSF__SHARED gsf_result gsf__nn_train_transformer(gsf_context* ctx, const gsf_nn_transformer* transformer,
                                                 gsf__nn_params* params, const gsf__dit_train_desc* desc, double* loss) {
    const gsf_nn_transformer* c = transformer;
    gsf_result result = GSF_OK;
    *loss = 0.0;
    GSF__TRY(gsf__dit_check_training(ctx, c, desc));
    const double count = (double)desc->frames * c->out_channels * desc->height * desc->width;
    for (int32_t b = 0; b < desc->batch && !result; b++) {
        const gsf__dit_example* e = &desc->examples[b];
        const double time = e->timestep;
        gsf_nn_transformer_desc in;
        gsf__dit_train t;
        memset(&t, 0, sizeof t);
        memset(&in, 0, sizeof in);
        in.batch = in.reference_batch = 1;
        in.frames = desc->frames;
        in.height = desc->height;
        in.width = desc->width;
        in.text = e->text;
        in.timesteps = &time;
        in.reference_tokens = e->reference_tokens;
        in.hidden = in.references = e->latents; // until there is memory; NULL means none
        if (!e->reference_tokens) in.references = NULL;
        t.params = params;
        GSF__TRY(gsf__dit_check_input(ctx, c, &in));
        gsf__dit_begin_run(&t.run, ctx, c);
        gsf__dit_set_input(&t.run, &in);
        float* memory = (float*)gsf_alloc(ctx, gsf__dit_lay_out_train(&t, NULL), sizeof(float));
        if (!memory) return GSF_ERROR_OUT_OF_MEMORY;
        gsf__dit_lay_out_train(&t, memory);
        in.hidden = t.out + (size_t)count;
        if (e->reference_tokens) in.references = t.references;
        result = gsf__dit_make_rope(&t.run);
        if (!result)
            result = gsf__dit_train_example(&t, desc, e, 1.0 / (count * desc->batch),
                                            desc->predicted ? desc->predicted + (size_t)b * (size_t)count : NULL, loss);
        gsf__nn_destroy_workspace(ctx, &t.run.nn.workspace);
        gsf_free(ctx, memory);
    }
    return result;
}

#endif // GSF_NN_TRAINING

GSF__END_IMPLEMENTATION

#endif // GSF__ISA
#endif // GSF_NN_IMPLEMENTED
#endif // GSFIXER_NN_IMPLEMENTATION
