/* gsfixer_splat.h - 3D Gaussian Splatting on the CPU: scenes, splats, rendering with gradients, training, repair
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       #define GSFIXER_SPLAT_IMPLEMENTATION   // in one file; or GSFIXER_IMPLEMENTATION for everything included
       #include "gsfixer_splat.h"             // includes gsfixer.h and gsfixer_traj.h

   CONVENTIONS (beside those of gsfixer.h)
       A splat is mean, log-scale, raw quaternion wxyz (normalised when used; zero = identity), opacity logit and
       SH coefficients (K,3) with K = (degree + 1)^2, the 3DGS parametrisation:
           Sigma = R diag(exp(log_scale))^2 R^T,  opacity = sigmoid(logit),  colour = max(0, SH(direction) + 0.5)
       Means are float32 relative to a double origin, so georeferenced scenes keep their precision.

   CONFIGURATION (define before the implementation)
       GSF_USE_EMBREE   visible-point filter by ray tracing (link embree3 or embree4); without it a z-buffer does it

   SECTIONS    >>splats >>ply >>colmap >>transforms >>undistort >>scene >>neighbours >>visibility >>embree
               >>project >>bin >>raster forward >>raster backward >>project backward >>render
               >>loss >>adam >>densify >>trainer >>warp >>fixer
   SOURCES     Kerbl et al. 2023 (3DGS), Zwicker et al. 2002 (EWA), Yu et al. 2024 (Mip-Splatting), GSFixer (the loop)
*/
#ifndef GSF_SPLAT_INCLUDED
#define GSF_SPLAT_INCLUDED

#include "gsfixer.h"
#include "gsfixer_traj.h"

#ifdef __cplusplus
extern "C" {
#endif

// ---- splats --------------------------------------------------------------------

typedef struct gsf_splats { // structure of arrays; all arrays have `count` rows
    size_t count;
    int32_t sh_degree;      // 0..3, of the stored coefficients
    double origin[3];       // world position of the means' zero
    float* means;           // (count,3) relative to origin
    float* log_scales;      // (count,3)
    float* quats;           // (count,4) w x y z, raw
    float* opacity_logits;  // (count)
    float* sh;              // (count,K,3), coefficient-major, RGB last
    uint32_t* ids;          // (count) stable names of the splats; unique
    void* owned;            // memory to free; NULL for views of caller arrays
} gsf_splats;

// Number of SH coefficients per channel of a degree: (degree + 1)^2.
GSF_API int32_t gsf_splat_sh_count(int32_t sh_degree);
// Zeroed splats with ids 0..count-1.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make(gsf_context* ctx, size_t count, int32_t sh_degree, gsf_splats* out);
GSF_API void gsf_splat_destroy(gsf_context* ctx, gsf_splats* splats);

// The standard 3DGS PLY: columns found by name, ascii and both endians, float and double. Splats with a non-finite
// value are dropped and counted in a warning. Origin: zero, or the rounded centre where coordinates are large.
GSF_API GSF_NODISCARD gsf_result gsf_splat_load_ply(gsf_context* ctx, const char* path, gsf_splats* out);
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_ply(gsf_context* ctx, const char* name, const void* data, size_t size,
                                                     gsf_splats* out);
// Binary little-endian float32 as the official code writes it; x y z become double when origin is not zero.
GSF_API GSF_NODISCARD gsf_result gsf_splat_save_ply(gsf_context* ctx, const char* path, const gsf_splats* splats);
GSF_API GSF_NODISCARD gsf_result gsf_splat_format_ply(gsf_context* ctx, const gsf_splats* splats, gsf_text* out);

// ---- scenes --------------------------------------------------------------------

typedef struct gsf_scene_view {
    char* name;           // image file name relative to the image folder
    uint32_t image_id;    // COLMAP's
    gsf_camera camera;    // pinhole, already at the size of `image` (undistorted, scaled)
    gsf_image image;      // u8 RGB; data is NULL until gsf_splat_load_view_image
} gsf_scene_view;

typedef struct gsf_scene {
    size_t view_count;
    gsf_scene_view* views;     // sorted by name (bytes)
    size_t point_count;
    double* points;            // (point_count,3) world
    uint8_t* colors;           // (point_count,3)
    uint64_t* point_ids;       // (point_count) COLMAP's
    size_t* track_begin;       // (point_count+1) into track_views; all zero when the scene has no tracks
    uint32_t* track_views;     // indices into views, ascending within a point, without repeats
    double origin[3];          // for splats made from this scene: mean camera centre
    char* folder;              // as given to the loader
    void* state;               // private: source cameras and sizes for gsf_splat_load_view_image
} gsf_scene;

typedef struct gsf_scene_desc {
    int32_t factor;    // images are 1/factor of the model's size: images_<factor>/ if present, else resized; 0 = 1
    int32_t max_size;  // shrink so that the longer side is at most this many pixels; 0 = no limit; not with factor
} gsf_scene_desc;

// Reads a COLMAP folder (images/ or images_<factor>/, sparse/0/ or sparse/ with {cameras,images,points3D}.{bin,txt}) or a
// nerfstudio / instant-ngp transforms.json (its folder or the file itself). Images are not read; their headers are, since
// a COLMAP camera is rescaled to the actual image size as the official parser does.
GSF_API GSF_NODISCARD gsf_result gsf_splat_load_scene(gsf_context* ctx, const char* path, const gsf_scene_desc* desc,
                                                      gsf_scene* out);
// In-memory twin: contents of the three COLMAP files, binary or text (told apart by content of `cameras`).
// `points` may be NULL. No images: view images stay empty, sizes are the cameras'.
typedef struct gsf_bytes { const void* data; size_t size; const char* name; } gsf_bytes; // name: for error texts
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_colmap(gsf_context* ctx, int is_text, const gsf_bytes* cameras,
                                                        const gsf_bytes* images, const gsf_bytes* points, gsf_scene* out);
// In-memory twin for transforms.json.
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_transforms(gsf_context* ctx, const gsf_bytes* json, gsf_scene* out);
// Decodes, undistorts and resizes one view's photo into view->image (kept if already there).
GSF_API GSF_NODISCARD gsf_result gsf_splat_load_view_image(gsf_context* ctx, gsf_scene* scene, size_t view);
// Writes <folder>/sparse/0/{cameras,images,points3D}.bin (PINHOLE cameras, tracks kept; the folder must exist).
// keep: NULL or one byte per point, zero = left out.
GSF_API GSF_NODISCARD gsf_result gsf_splat_save_colmap(gsf_context* ctx, const gsf_scene* scene, const uint8_t* keep,
                                                       const char* folder);
GSF_API void gsf_splat_destroy_scene(gsf_context* ctx, gsf_scene* scene);

// The papers' split of n name-sorted views: every test_every-th is a test view, train = round(linspace(0, m-1, K)) over
// the other m (half to even). Counts are returned; arrays hold up to n entries and may be NULL. K <= 0: all the rest.
GSF_API void gsf_splat_split_views(size_t n, size_t test_every, size_t train_target, uint32_t* train,
                                   size_t* train_count, uint32_t* test, size_t* test_count);

// ---- visible-point filter ------------------------------------------------------

typedef enum gsf_visibility_method {
    GSF_VISIBILITY_BOTH = 0, // seen by track or by ray (default)
    GSF_VISIBILITY_TRACKS,   // the official code: the point's track holds one of the views
    GSF_VISIBILITY_RAYS,     // points as oriented discs; Embree, or a z-buffer of the same discs without it
} gsf_visibility_method;

typedef struct gsf_visibility_desc {
    gsf_visibility_method method;
    int32_t neighbours;    // for normals, default 12
    int32_t radius_neighbour; // disc radius = distance to this neighbour, default 6
    float radius_scale;    // times this, default 1.0
    float tolerance;       // a point is hidden when something blocks its ray more than this many radii before it; default 1
    float min_grazing_cos; // |cos| between ray and normal below which no ray is shot, default 0.02
    int32_t use_zbuffer;   // rays by the z-buffer even where Embree is compiled in
} gsf_visibility_desc;

typedef struct gsf_visibility_stats {
    size_t points, kept, by_tracks, by_rays;  // by_rays: kept by rays (also those that tracks keep)
    size_t rays, culled;                      // rays shot; (point, view) pairs rejected before a ray was needed
    double seconds_normals, seconds_build, seconds_rays;
    int32_t used_embree;
} gsf_visibility_stats;

// keep[i] = 1 where some of the given views sees point i. stats may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_splat_visible_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                                          size_t view_count, const gsf_visibility_desc* desc,
                                                          uint8_t* keep, gsf_visibility_stats* stats);

// Initial splats from points: scale = sqrt(mean squared distance to the 3 nearest), opacity 0.1, SH dc from colour.
// keep: NULL or one byte per point. Ids are the rows of the scene's points.
GSF_API GSF_NODISCARD gsf_result gsf_splat_from_points(gsf_context* ctx, const double* points, const uint8_t* colors,
                                                       size_t count, const uint8_t* keep, int32_t sh_degree,
                                                       const double origin[3], gsf_splats* out);

// ---- rendering -----------------------------------------------------------------

typedef enum gsf_footprint {
    GSF_FOOTPRINT_FULL = 0, // a splat reaches every pixel where its alpha is at least 1/255
    GSF_FOOTPRINT_OFFICIAL, // only the 16x16 tiles of its 3-sigma square, as the official CUDA rasterizer
} gsf_footprint;

typedef enum gsf_gradient {
    GSF_GRADIENT_TRUE = 0,  // the derivative of what was rendered
    GSF_GRADIENT_OFFICIAL,  // straight through the 0.99 alpha clamp; the clamped x/z held constant
} gsf_gradient;

typedef struct gsf_render_desc {
    int32_t sh_bands;          // SH bands evaluated: degree + 1; 0 = all that are stored
    float background[3];
    gsf_footprint footprint;
    gsf_gradient gradient;
    int32_t antialiased;       // Mip-Splatting's 2D filter: opacity times sqrt(det/det_blurred)
    float near_plane;          // splats with camera depth <= this are culled; 0 = 0.2 (official)
    const uint8_t* hidden;     // NULL or one byte per splat: non-zero splats are not drawn (dropout)
    float opacity_scale;       // every opacity is multiplied by this; 0 = 1
} gsf_render_desc;

typedef struct gsf_render_output { // caller's images, all f32 of the camera's size; data NULL = not wanted
    gsf_image color;   // 3 channels, not clamped
    gsf_image depth;   // 1 channel: expected camera depth sum(w z)/sum(w), 0 where nothing was blended
    gsf_image alpha;   // 1 channel: 1 - final transmittance
} gsf_render_output;

// Gradients, each (count, ...) like the parameter, accumulated (+=); NULL = not wanted.
typedef struct gsf_splat_grads {
    float* means;           // (count,3)
    float* log_scales;      // (count,3)
    float* quats;           // (count,4), with respect to the raw quaternion
    float* opacity_logits;  // (count)
    float* sh;              // (count,K,3), K of the stored degree
    float* means2d;         // (count,2) per pixel; times (W/2, H/2) and the norm: the densification statistic
    float* means2d_abs;     // (count,2) the same with |.| per pixel before the sum (AbsGS)
    float* background;      // (3)
} gsf_splat_grads;

// Workspace of the rasterizer: what backward needs of the last forward. Buffers only grow, so steady rendering does not
// allocate. One rasterizer serves one thread at a time (it splits its work through the context's parallel hook).
typedef struct gsf_rasterizer gsf_rasterizer;
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_rasterizer(gsf_context* ctx, gsf_rasterizer** out);
GSF_API void gsf_splat_destroy_rasterizer(gsf_context* ctx, gsf_rasterizer* rasterizer);

// Renders splats as `camera` sees them. Splats with a non-finite value are skipped.
GSF_API GSF_NODISCARD gsf_result gsf_splat_render(gsf_context* ctx, gsf_rasterizer* rasterizer, const gsf_splats* splats,
                                                  const gsf_camera* camera, const gsf_render_desc* desc,
                                                  const gsf_render_output* out);
// Gradient of a loss through the last gsf_splat_render of this rasterizer (same splats, camera and desc).
// d_color (H,W,3), d_depth (H,W), d_alpha (H,W): packed f32 derivatives of the loss; NULL = zero.
GSF_API GSF_NODISCARD gsf_result gsf_splat_render_backward(gsf_context* ctx, gsf_rasterizer* rasterizer,
                                                           const gsf_splats* splats, const gsf_camera* camera,
                                                           const gsf_render_desc* desc, const float* d_color,
                                                           const float* d_depth, const float* d_alpha,
                                                           const gsf_splat_grads* grads);
// Radii in pixels (0 = culled) of the last render, (count); valid until the next render.
GSF_API const int32_t* gsf_splat_last_radii(const gsf_rasterizer* rasterizer);

// ---- training ------------------------------------------------------------------

typedef struct gsf_train_view {
    gsf_camera camera;
    gsf_image image;   // u8 or f32 RGB, same size as the camera; copied
    gsf_image weight;  // f32, 1 channel: per-pixel weight of the loss (a restorer's confidence); data NULL = 1; copied
} gsf_train_view;

typedef struct gsf_train_desc { // zero = the official 3DGS value given beside each field
    int32_t iterations;            // 30000; the schedules below scale with iterations / 30000 unless set
    uint64_t seed;
    int32_t sh_degree;             // degree to train; 0 = the splats' own
    int32_t sh_interval;           // 1000: iterations per further SH band
    float lr_means, lr_means_final;// 1.6e-4, 1.6e-6, both times extent, exponential decay
    float lr_sh_dc, lr_sh_rest, lr_opacity, lr_scales, lr_quats; // 2.5e-3, 1.25e-4, 0.025, 5e-3, 1e-3
    float extent;                  // 1.1 * largest distance of a training camera from their mean
    float lambda_ssim;             // 0.2
    float background[3];
    int32_t densify_from, densify_until, densify_interval; // 500, 15000, 100; densify_until < 0 = never
    float densify_grad;            // 2e-4
    float densify_scale;           // 0.01: clone below this share of extent, split above
    float prune_opacity;           // 0.005
    float prune_scale;             // 0.1 of extent, after the first opacity reset
    int32_t opacity_reset_interval;// 3000
    size_t max_splats;             // densification stops growing here; 0 = 2 million
    gsf_render_desc render;        // footprint, gradient kind, antialiasing, near plane (background is taken from above)
    // regularisers for few views; zero = off
    float dropout;                 // largest share of splats hidden in a step (grows linearly over training)
    float opacity_decay;           // opacities shrink by this factor each 100 iterations... 
    float scale_penalty;           // weight of mean(exp(log_scale))/extent
    float depth_smoothness;        // weight of edge-aware smoothness of rendered inverse depth
} gsf_train_desc;

typedef struct gsf_train_stats {
    int32_t iteration;     // just done, from 1
    size_t splats;
    double loss, l1, ssim; // of this step's view
    size_t rejected;       // non-finite gradients or parameters neutralised so far
} gsf_train_stats;

typedef struct gsf_trainer gsf_trainer;

// The trainer copies views and splats. Steps are deterministic: same bits for any number of workers.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_trainer(gsf_context* ctx, const gsf_train_desc* desc,
                                                        const gsf_train_view* views, size_t view_count,
                                                        const gsf_splats* initial, gsf_trainer** out);
GSF_API void gsf_splat_destroy_trainer(gsf_context* ctx, gsf_trainer* trainer);
// One iteration. After the last one it is GSF_ERROR_INVALID_ARGUMENT.
GSF_API GSF_NODISCARD gsf_result gsf_splat_train_step(gsf_context* ctx, gsf_trainer* trainer, gsf_train_stats* stats);
// Replaces the restored views (their loss has weight `lambda`, may be changed at any time). count 0 removes them.
GSF_API GSF_NODISCARD gsf_result gsf_splat_set_restored_views(gsf_context* ctx, gsf_trainer* trainer,
                                                              const gsf_train_view* views, size_t count);
GSF_API void gsf_splat_set_restored_weight(gsf_trainer* trainer, float lambda);
// Renders the current state (between steps).
GSF_API GSF_NODISCARD gsf_result gsf_splat_trainer_render(gsf_context* ctx, gsf_trainer* trainer,
                                                          const gsf_camera* camera, const gsf_render_output* out);
// A copy of the current splats.
GSF_API GSF_NODISCARD gsf_result gsf_splat_trainer_export(gsf_context* ctx, const gsf_trainer* trainer, gsf_splats* out);
// The current splats, borrowed until the next step.
GSF_API const gsf_splats* gsf_splat_trainer_splats(const gsf_trainer* trainer);
// Adds the whole state as chunks / continues from it, bit-identically. Views and desc are the caller's to give again.
GSF_API void gsf_splat_trainer_save(gsf_context* ctx, const gsf_trainer* trainer, gsf_text* chunks);
GSF_API GSF_NODISCARD gsf_result gsf_splat_trainer_restore(gsf_context* ctx, gsf_trainer* trainer, const char* name,
                                                           const void* chunks, size_t size);

// ---- restorers -----------------------------------------------------------------

// Training-free restorer: reprojects the reference photos through the splats' depth with occlusion tests, blends by
// confidence, keeps the render where no reference sees. Fills *out; out->user is freed by gsf_splat_destroy_warp.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_warp(gsf_context* ctx, gsf_restorer* out);
GSF_API void gsf_splat_destroy_warp(gsf_context* ctx, gsf_restorer* restorer);

#ifdef __cplusplus
}
#endif

#endif // GSF_SPLAT_INCLUDED

// ================================================================================
// The API ends here. What follows is the implementation.
// ================================================================================

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_SPLAT_IMPLEMENTATION)
#define GSFIXER_SPLAT_IMPLEMENTATION
#endif
#if defined(GSFIXER_SPLAT_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_SPLAT_IMPLEMENTED
#define GSF_SPLAT_IMPLEMENTED

GSF__BEGIN_IMPLEMENTATION

// ---- >>splats ------------------------------------------------------------------

GSF_API int32_t gsf_splat_sh_count(int32_t sh_degree) { return (sh_degree + 1) * (sh_degree + 1); }

GSF_API gsf_result gsf_splat_make(gsf_context* ctx, size_t count, int32_t sh_degree, gsf_splats* out) {
    memset(out, 0, sizeof *out);
    if (sh_degree < 0 || sh_degree > 3)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "splats: SH degree %d is not 0..3", (int)sh_degree);
    const size_t sh_floats = 3 * (size_t)gsf_splat_sh_count(sh_degree);
    const size_t row = 3 + 3 + 4 + 1 + sh_floats + 1; // the id is 4 bytes too
    float* block = (float*)gsf_alloc_zeroed(ctx, count ? count : 1, row * sizeof(float));
    if (!block) return GSF_ERROR_OUT_OF_MEMORY;
    out->count = count;
    out->sh_degree = sh_degree;
    out->owned = block;
    out->means = block;
    out->log_scales = out->means + 3 * count;
    out->quats = out->log_scales + 3 * count;
    out->opacity_logits = out->quats + 4 * count;
    out->sh = out->opacity_logits + count;
    out->ids = (uint32_t*)(void*)(out->sh + sh_floats * count);
    for (size_t i = 0; i < count; i++) out->ids[i] = (uint32_t)i;
    return GSF_OK;
}

GSF_API void gsf_splat_destroy(gsf_context* ctx, gsf_splats* splats) {
    gsf_free(ctx, splats->owned);
    memset(splats, 0, sizeof *splats);
}

// ---- >>ply ---------------------------------------------------------------------

// ---- >>colmap ------------------------------------------------------------------

// ---- >>transforms --------------------------------------------------------------

// ---- >>undistort ---------------------------------------------------------------

// ---- >>scene -------------------------------------------------------------------

// ---- >>neighbours --------------------------------------------------------------

// ---- >>visibility --------------------------------------------------------------

// ---- >>embree ------------------------------------------------------------------

// ---- >>project -----------------------------------------------------------------

// ---- >>bin ---------------------------------------------------------------------

// ---- >>raster forward ----------------------------------------------------------

// ---- >>raster backward ---------------------------------------------------------

// ---- >>project backward --------------------------------------------------------

// ---- >>render ------------------------------------------------------------------

// ---- >>loss --------------------------------------------------------------------

// ---- >>adam --------------------------------------------------------------------

// ---- >>densify -----------------------------------------------------------------

// ---- >>trainer -----------------------------------------------------------------

// ---- >>warp --------------------------------------------------------------------

// ---- >>fixer -------------------------------------------------------------------

GSF__END_IMPLEMENTATION

#endif // GSF_SPLAT_IMPLEMENTED
#endif // GSFIXER_SPLAT_IMPLEMENTATION
