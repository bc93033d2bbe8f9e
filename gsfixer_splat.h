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
       GSF_EMBREE_INCLUDE   default <embree4/rtcore.h> where there is one, else <embree3/rtcore.h>

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
    size_t points, kept, by_tracks, by_rays;  // by_rays: kept by rays; no ray goes to what tracks keep
    size_t rays, culled;                      // rays shot; (point, view) pairs rejected before a ray was needed
    double seconds_normals, seconds_build, seconds_rays;
    int32_t used_embree;
} gsf_visibility_stats;

// keep[i] = 1 where some of the given views sees point i. stats may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_splat_visible_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                                          size_t view_count, const gsf_visibility_desc* desc,
                                                          uint8_t* keep, gsf_visibility_stats* stats);

// Initial splats from points: scale = sqrt(mean squared distance to the 3 nearest kept points, at least 1e-7), opacity 0.1,
// SH dc from colour (the official create_from_pcd). keep: NULL or one byte per point. origin: NULL = zero. Ids are the
// rows of the points. Points with a non-finite coordinate make no splat and are counted in a warning.
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

#include "gsfixer.h" // again: internals and implementations, if all was included before without the macro
#include "gsfixer_traj.h"

#include <time.h>

#ifdef GSF_USE_EMBREE
#ifndef GSF_EMBREE_INCLUDE
#if defined(__has_include)
#if __has_include(<embree4/rtcore.h>)
#define GSF_EMBREE_INCLUDE <embree4/rtcore.h>
#endif
#endif
#ifndef GSF_EMBREE_INCLUDE
#define GSF_EMBREE_INCLUDE <embree3/rtcore.h>
#endif
#endif
#include GSF_EMBREE_INCLUDE
#endif

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

/* Exact nearest neighbours: a balanced kd-tree without pointers. Node i of level l covers the rows
   [n i / 2^l, n (i+1) / 2^l) of a permutation of the points and stands at 2^l - 1 + i of `boxes`; it is split at the
   median of the widest axis of its bounding box. So the depth is log2(n / 8) for any cloud, clustered or not. */
typedef struct gsf__knn_tree {
    size_t count;
    uint32_t levels;  // the leaves are the nodes of this level
    double* points;   // (count,3) in tree order
    uint32_t* rows;   // (count) caller's row of each point in tree order
    double* boxes;    // (2^(levels+1) - 1, 6): minimum xyz, maximum xyz
} gsf__knn_tree;

enum { GSF__KNN_LEAF = 8, GSF__KNN_MAX = 64, GSF__KNN_CHUNK = 1024 };

static size_t gsf__knn_begin(const gsf__knn_tree* tree, uint32_t level, size_t node) {
    return (size_t)(((uint64_t)tree->count * node) >> level); // count and node are below 2^32
}

static void gsf__knn_swap(gsf__knn_tree* tree, size_t a, size_t b) {
    double *p = tree->points + 3 * a, *q = tree->points + 3 * b;
    for (int k = 0; k < 3; k++) {
        const double t = p[k];
        p[k] = q[k];
        q[k] = t;
    }
    const uint32_t row = tree->rows[a];
    tree->rows[a] = tree->rows[b];
    tree->rows[b] = row;
}

// Partial sort: afterwards nothing in [begin,nth) is above and nothing in [nth,end) is below point nth along the axis.
// Three-way, so equal coordinates cost nothing; the pivots are random but reproducible.
static void gsf__knn_select(gsf__knn_tree* tree, size_t begin, size_t nth, size_t end, int axis) {
    while (end - begin > 1) {
        const size_t pick = begin + (size_t)(gsf_random_bits(begin, end, nth) % (end - begin));
        const double pivot = tree->points[3 * pick + (size_t)axis];
        size_t below = begin, above = end;
        for (size_t i = begin; i < above;) {
            const double x = tree->points[3 * i + (size_t)axis];
            if (x < pivot) gsf__knn_swap(tree, i++, below++);
            else if (x > pivot) gsf__knn_swap(tree, i, --above);
            else i++;
        }
        if (nth < below) end = below;
        else if (nth >= above) begin = above;
        else return;
    }
}

typedef struct gsf__knn_build_job {
    gsf__knn_tree* tree;
    uint32_t level;
    size_t nodes_per_chunk;
} gsf__knn_build_job;

static void gsf__knn_build_chunk(void* arg, size_t chunk, int worker) {
    (void)worker;
    const gsf__knn_build_job* job = (const gsf__knn_build_job*)arg;
    gsf__knn_tree* tree = job->tree;
    const size_t node_count = (size_t)1 << job->level;
    const size_t first = chunk * job->nodes_per_chunk;
    for (size_t node = first; node < node_count && node < first + job->nodes_per_chunk; node++) {
        const size_t begin = gsf__knn_begin(tree, job->level, node), end = gsf__knn_begin(tree, job->level, node + 1);
        double* box = tree->boxes + 6 * (node_count - 1 + node);
        for (int k = 0; k < 3; k++) box[k] = box[3 + k] = tree->points[3 * begin + (size_t)k];
        for (size_t i = begin + 1; i < end; i++)
            for (int k = 0; k < 3; k++) {
                const double x = tree->points[3 * i + (size_t)k];
                if (x < box[k]) box[k] = x;
                if (x > box[3 + k]) box[3 + k] = x;
            }
        if (job->level == tree->levels) continue;
        int axis = 0;
        for (int k = 1; k < 3; k++)
            if (box[3 + k] - box[k] > box[3 + axis] - box[axis]) axis = k;
        gsf__knn_select(tree, begin, gsf__knn_begin(tree, job->level + 1, 2 * node + 1), end, axis);
    }
}

static void gsf__knn_destroy(gsf_context* ctx, gsf__knn_tree* tree) {
    gsf_free(ctx, tree->points);
    gsf_free(ctx, tree->rows);
    gsf_free(ctx, tree->boxes);
    memset(tree, 0, sizeof *tree);
}

// Tree over those of the `count` points (stride 3) whose byte in `keep` is not zero (NULL: all). Points with a
// non-finite coordinate are left out; tree->count says how many are in.
static gsf_result gsf__knn_build(gsf_context* ctx, const double* points, size_t count, const uint8_t* keep,
                                 gsf__knn_tree* tree) {
    memset(tree, 0, sizeof *tree);
    if ((uint64_t)count >= UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "points: %zu are more than 32-bit rows can name", count);
    size_t n = 0;
    for (size_t i = 0; i < count; i++) {
        const double* p = points + 3 * i;
        n += (!keep || keep[i]) && isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2]);
    }
    while (n >> tree->levels > GSF__KNN_LEAF) tree->levels++;
    tree->points = (double*)gsf_alloc(ctx, n ? n : 1, 3 * sizeof(double));
    tree->rows = (uint32_t*)gsf_alloc(ctx, n ? n : 1, sizeof(uint32_t));
    tree->boxes = (double*)gsf_alloc(ctx, (size_t)2 << tree->levels, 6 * sizeof(double));
    if (!tree->points || !tree->rows || !tree->boxes) {
        gsf__knn_destroy(ctx, tree);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    for (size_t i = 0; i < count; i++) {
        const double* p = points + 3 * i;
        if (!((!keep || keep[i]) && isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2]))) continue;
        memcpy(tree->points + 3 * tree->count, p, 3 * sizeof(double));
        tree->rows[tree->count++] = (uint32_t)i;
    }
    if (n == 0) return GSF_OK;
    gsf__knn_build_job job;
    job.tree = tree;
    for (job.level = 0; job.level <= tree->levels; job.level++) {
        const size_t nodes = (size_t)1 << job.level;
        job.nodes_per_chunk = (nodes + 255) / 256;
        gsf__parallel_for(ctx, (nodes + job.nodes_per_chunk - 1) / job.nodes_per_chunk, gsf__knn_build_chunk, &job);
    }
    return GSF_OK;
}

static double gsf__knn_box_distance2(const double box[6], const double q[3]) {
    double sum = 0.0;
    for (int k = 0; k < 3; k++) {
        const double d = q[k] < box[k] ? box[k] - q[k] : q[k] > box[3 + k] ? q[k] - box[3 + k] : 0.0;
        sum += d * d;
    }
    return sum;
}

// The k points nearest to q (k <= GSF__KNN_MAX), nearest first: squared distances and places in tree order. `skip` is a
// place to leave out (SIZE_MAX: none). Returns how many were found (fewer than k when the tree holds fewer).
// Among equally distant points the choice is fixed by the tree.
static int gsf__knn_query(const gsf__knn_tree* tree, const double q[3], size_t skip, int k, double* distance2,
                          size_t* places) {
    struct { size_t node; double distance2; uint32_t level; } stack[40];
    int depth = 0, found = 0;
    if (tree->count == 0) return 0;
    stack[depth].node = 0;
    stack[depth].distance2 = 0.0;
    stack[depth++].level = 0;
    while (depth > 0) {
        depth--;
        size_t node = stack[depth].node;
        uint32_t level = stack[depth].level;
        if (found == k && stack[depth].distance2 >= distance2[k - 1]) continue;
        while (level < tree->levels) { // down to the nearer child, the farther waits
            level++;
            const double* boxes = tree->boxes + 6 * (((size_t)1 << level) - 1 + 2 * node);
            const double left = gsf__knn_box_distance2(boxes, q), right = gsf__knn_box_distance2(boxes + 6, q);
            const size_t far_bit = left <= right;
            stack[depth].node = 2 * node + far_bit;
            stack[depth].distance2 = far_bit ? right : left;
            stack[depth++].level = level;
            node = 2 * node + (1 - far_bit);
        }
        const size_t end = gsf__knn_begin(tree, level, node + 1);
        for (size_t i = gsf__knn_begin(tree, level, node); i < end; i++) {
            const double* p = tree->points + 3 * i;
            const double x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
            const double d = x * x + y * y + z * z;
            if (i == skip || (found == k && d >= distance2[k - 1])) continue;
            int at = found < k ? found++ : k - 1;
            for (; at > 0 && distance2[at - 1] > d; at--) {
                distance2[at] = distance2[at - 1];
                places[at] = places[at - 1];
            }
            distance2[at] = d;
            places[at] = i;
        }
    }
    return found;
}

typedef struct gsf__init_job {
    const gsf__knn_tree* tree;
    float* log_scales; // by place in the tree
} gsf__init_job;

static void gsf__init_scales_chunk(void* arg, size_t chunk, int worker) {
    (void)worker;
    const gsf__init_job* job = (const gsf__init_job*)arg;
    const size_t first = chunk * GSF__KNN_CHUNK;
    for (size_t i = first; i < job->tree->count && i < first + GSF__KNN_CHUNK; i++) {
        double distance2[3];
        size_t places[3];
        const int found = gsf__knn_query(job->tree, job->tree->points + 3 * i, i, 3, distance2, places);
        double mean = 0.0;
        for (int k = 0; k < found; k++) mean += distance2[k];
        if (found) mean /= found;
        job->log_scales[i] = (float)(0.5 * log(mean > 1e-7 ? mean : 1e-7));
    }
}

#define GSF__SH_C0 0.28209479177387814 // SH basis function 0

GSF_API gsf_result gsf_splat_from_points(gsf_context* ctx, const double* points, const uint8_t* colors, size_t count,
                                         const uint8_t* keep, int32_t sh_degree, const double origin[3],
                                         gsf_splats* out) {
    memset(out, 0, sizeof *out);
    if (count && (!points || !colors))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "splats from points: points or colours are missing");
    if (origin && !(isfinite(origin[0]) && isfinite(origin[1]) && isfinite(origin[2])))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "splats from points: the origin is not finite");
    gsf__knn_tree tree;
    GSF__TRY(gsf__knn_build(ctx, points, count, keep, &tree));
    float* log_scales = (float*)gsf_alloc(ctx, tree.count ? tree.count : 1, sizeof(float));
    uint32_t* order = (uint32_t*)gsf_alloc(ctx, count ? count : 1, sizeof(uint32_t)); // row -> place in the tree
    gsf_result result = log_scales && order ? gsf_splat_make(ctx, tree.count, sh_degree, out) : GSF_ERROR_OUT_OF_MEMORY;
    if (result != GSF_OK) goto cleanup;
    {
        gsf__init_job job;
        job.tree = &tree;
        job.log_scales = log_scales;
        gsf__parallel_for(ctx, (tree.count + GSF__KNN_CHUNK - 1) / GSF__KNN_CHUNK, gsf__init_scales_chunk, &job);

        size_t kept = 0, n = 0;
        for (size_t i = 0; i < count; i++) order[i] = UINT32_MAX;
        for (size_t i = 0; i < tree.count; i++) order[tree.rows[i]] = (uint32_t)i;
        if (origin) memcpy(out->origin, origin, sizeof out->origin);
        const size_t sh_floats = 3 * (size_t)gsf_splat_sh_count(sh_degree);
        for (size_t i = 0; i < count; i++) {
            kept += !keep || keep[i];
            if (order[i] == UINT32_MAX) continue;
            for (size_t k = 0; k < 3; k++) {
                out->means[3 * n + k] = (float)(points[3 * i + k] - out->origin[k]);
                out->log_scales[3 * n + k] = log_scales[order[i]];
                out->sh[sh_floats * n + k] = (float)((colors[3 * i + k] / 255.0 - 0.5) / GSF__SH_C0);
            }
            out->quats[4 * n] = 1.0f;
            out->opacity_logits[n] = -2.1972245773362196f; // log(0.1 / 0.9)
            out->ids[n++] = (uint32_t)i;
        }
        if (n < kept)
            gsf_log(ctx, GSF_LOG_WARNING, "%zu points with a non-finite coordinate make no splat", kept - n);
    }
cleanup:
    gsf_free(ctx, order);
    gsf_free(ctx, log_scales);
    gsf__knn_destroy(ctx, &tree);
    return result;
}

// ---- >>visibility --------------------------------------------------------------

typedef struct gsf__discs { // the points as oriented discs, in tree order (neighbours lie close in memory)
    size_t count;
    double origin[3];  // float coordinates are relative to it
    float* spheres;    // (count + 1,4) centre, radius; one spare row since Embree loads 16 bytes at a time
    float* normals;    // (count + 2,3) unit
    uint32_t* rows;    // (count) row of the scene's point
} gsf__discs;

static double gsf__vis_seconds(void) { // for the statistics only
    struct timespec t;
    return timespec_get(&t, TIME_UTC) ? (double)t.tv_sec + 1e-9 * (double)t.tv_nsec : 0.0;
}

static gsf_visibility_desc gsf__visibility_desc_defaults(const gsf_visibility_desc* desc) {
    gsf_visibility_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.neighbours == 0) d.neighbours = 12;
    if (d.radius_neighbour == 0) d.radius_neighbour = 6;
    if (d.radius_scale == 0.0f) d.radius_scale = 1.0f;
    if (d.tolerance == 0.0f) d.tolerance = 1.0f;
    if (d.min_grazing_cos == 0.0f) d.min_grazing_cos = 0.02f;
    return d;
}

static gsf_result gsf__visibility_check(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                        size_t view_count, const gsf_visibility_desc* d) {
    if ((unsigned)d->method > GSF_VISIBILITY_RAYS)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "visible points: method %d", (int)d->method);
    if (d->neighbours < 3 || d->neighbours > GSF__KNN_MAX || d->radius_neighbour < 1 ||
        d->radius_neighbour > GSF__KNN_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "visible points: neighbours %d, radius_neighbour %d (at most %d)",
                        (int)d->neighbours, (int)d->radius_neighbour, (int)GSF__KNN_MAX);
    if (!(d->radius_scale > 0.0f && d->radius_scale < 1e6f && d->tolerance > 0.0f && d->tolerance < 1e6f &&
          d->min_grazing_cos > 0.0f && d->min_grazing_cos < 1.0f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "visible points: radius_scale %g, tolerance %g, min_grazing_cos %g", (double)d->radius_scale,
                        (double)d->tolerance, (double)d->min_grazing_cos);
    if (view_count && !views) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "visible points: no list of views");
    for (size_t i = 0; i < view_count; i++) {
        if (views[i] >= scene->view_count)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "visible points: view %u, the scene has %zu",
                            (unsigned)views[i], scene->view_count);
        GSF__TRY(gsf_check_camera(ctx, &scene->views[views[i]].camera));
    }
    return GSF_OK;
}

// Unit eigenvector of the smallest eigenvalue of a symmetric 3x3 matrix, by Jacobi rotations. a is overwritten.
static void gsf__smallest_eigenvector(double a[3][3], double out[3]) {
    double v[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    for (int sweep = 0; sweep < 12; sweep++) {
        const double off = fabs(a[0][1]) + fabs(a[0][2]) + fabs(a[1][2]);
        if (!(off > 1e-14 * (a[0][0] + a[1][1] + a[2][2]))) break;
        for (int p = 0; p < 2; p++)
            for (int q = p + 1; q < 3; q++) {
                if (a[p][q] == 0.0) continue;
                const double theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                const double t = (theta < 0.0 ? -1.0 : 1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
                const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
                for (int k = 0; k < 3; k++) { // columns p, q
                    const double x = a[k][p], y = a[k][q];
                    a[k][p] = c * x - s * y;
                    a[k][q] = s * x + c * y;
                }
                for (int k = 0; k < 3; k++) { // rows p, q
                    const double x = a[p][k], y = a[q][k];
                    a[p][k] = c * x - s * y;
                    a[q][k] = s * x + c * y;
                }
                for (int k = 0; k < 3; k++) {
                    const double x = v[k][p], y = v[k][q];
                    v[k][p] = c * x - s * y;
                    v[k][q] = s * x + c * y;
                }
            }
    }
    int least = 0;
    for (int k = 1; k < 3; k++)
        if (a[k][k] < a[least][least]) least = k;
    for (int k = 0; k < 3; k++) out[k] = v[k][least];
}

typedef struct gsf__disc_job {
    const gsf__knn_tree* tree;
    const gsf_visibility_desc* desc;
    gsf__discs* discs;
} gsf__disc_job;

static void gsf__discs_chunk(void* arg, size_t chunk, int worker) {
    (void)worker;
    const gsf__disc_job* job = (const gsf__disc_job*)arg;
    const gsf__knn_tree* tree = job->tree;
    const int wanted = job->desc->neighbours > job->desc->radius_neighbour ? job->desc->neighbours
                                                                          : job->desc->radius_neighbour;
    const size_t first = chunk * GSF__KNN_CHUNK;
    for (size_t i = first; i < tree->count && i < first + GSF__KNN_CHUNK; i++) {
        const double* p = tree->points + 3 * i;
        double distance2[GSF__KNN_MAX];
        size_t places[GSF__KNN_MAX];
        const int found = gsf__knn_query(tree, p, i, wanted, distance2, places);
        const int used = found < job->desc->neighbours ? found : job->desc->neighbours;
        double mean[3] = {0.0, 0.0, 0.0}, cov[3][3]; // about the mean of the neighbours and the point, relative to p
        memset(cov, 0, sizeof cov);
        for (int k = 0; k < used; k++)
            for (int a = 0; a < 3; a++) mean[a] += (tree->points[3 * places[k] + (size_t)a] - p[a]) / (used + 1);
        for (int k = -1; k < used; k++) {
            double d[3];
            for (int a = 0; a < 3; a++) d[a] = (k < 0 ? 0.0 : tree->points[3 * places[k] + (size_t)a] - p[a]) - mean[a];
            for (int a = 0; a < 3; a++)
                for (int b = 0; b < 3; b++) cov[a][b] += d[a] * d[b];
        }
        double normal[3];
        gsf__smallest_eigenvector(cov, normal);
        const int at = found < job->desc->radius_neighbour ? found : job->desc->radius_neighbour;
        float* sphere = job->discs->spheres + 4 * i;
        for (int a = 0; a < 3; a++) {
            sphere[a] = (float)(p[a] - job->discs->origin[a]);
            job->discs->normals[3 * i + (size_t)a] = (float)normal[a];
        }
        sphere[3] = (float)(at ? (double)job->desc->radius_scale * sqrt(distance2[at - 1]) : 0.0);
        job->discs->rows[i] = tree->rows[i];
    }
}

static void gsf__discs_destroy(gsf_context* ctx, gsf__discs* discs) {
    gsf_free(ctx, discs->spheres);
    gsf_free(ctx, discs->normals);
    gsf_free(ctx, discs->rows);
    memset(discs, 0, sizeof *discs);
}

static int gsf__compare_floats(const void* a, const void* b) {
    float x, y;
    memcpy(&x, a, sizeof x);
    memcpy(&y, b, sizeof y);
    return (x > y) - (x < y);
}

// Normals by PCA of the neighbours; radius = distance to a neighbour, at most 3 times the median (lone points would
// hide whole walls) and at least 1e-5 of the coordinates (below that float ray tests miss, measured on Embree 3.13.5).
static gsf_result gsf__discs_make(gsf_context* ctx, const gsf_scene* scene, const double origin[3],
                                  const gsf_visibility_desc* desc, gsf__discs* discs) {
    memset(discs, 0, sizeof *discs);
    gsf__knn_tree tree;
    GSF__TRY(gsf__knn_build(ctx, scene->points, scene->point_count, NULL, &tree));
    gsf_result result = GSF_ERROR_OUT_OF_MEMORY;
    float* radii = (float*)gsf_alloc(ctx, tree.count ? tree.count : 1, sizeof(float));
    memcpy(discs->origin, origin, sizeof discs->origin);
    discs->spheres = (float*)gsf_alloc_zeroed(ctx, tree.count + 1, 4 * sizeof(float));
    discs->normals = (float*)gsf_alloc_zeroed(ctx, tree.count + 2, 3 * sizeof(float));
    discs->rows = (uint32_t*)gsf_alloc(ctx, tree.count ? tree.count : 1, sizeof(uint32_t));
    if (!radii || !discs->spheres || !discs->normals || !discs->rows) goto cleanup;
    discs->count = tree.count;
    {
        gsf__disc_job job;
        job.tree = &tree;
        job.desc = desc;
        job.discs = discs;
        gsf__parallel_for(ctx, (tree.count + GSF__KNN_CHUNK - 1) / GSF__KNN_CHUNK, gsf__discs_chunk, &job);
    }
    {
        size_t n = 0;
        for (size_t i = 0; i < discs->count; i++) // piles of equal points have radius 0 and do not count
            if (discs->spheres[4 * i + 3] > 0.0f) radii[n++] = discs->spheres[4 * i + 3];
        qsort(radii, n, sizeof(float), gsf__compare_floats);
        const float most = n ? 3.0f * radii[n / 2] : 0.0f;
        for (size_t i = 0; i < discs->count; i++) {
            float* s = discs->spheres + 4 * i;
            const float least = 1e-5f * (fabsf(s[0]) + fabsf(s[1]) + fabsf(s[2]));
            if (s[3] > most) s[3] = most;
            if (s[3] < least) s[3] = least;
        }
    }
    result = gsf__check_cancel(ctx);
cleanup:
    if (result != GSF_OK) gsf__discs_destroy(ctx, discs);
    gsf_free(ctx, radii);
    gsf__knn_destroy(ctx, &tree);
    return result;
}

typedef struct gsf__eye { // a view, prepared
    gsf_camera camera;
    double center[3]; // relative to the discs' origin
} gsf__eye;

typedef struct gsf__sight { // a disc as seen from an eye
    double camera[3];    // camera coordinates
    double direction[3]; // unit, from the eye, in the discs' axes
    double distance, u, v;
} gsf__sight;

typedef struct gsf__disc_image { // a disc in the z-buffer's camera
    float center[3], normal[3], radius2;
    int32_t x0, x1, y0, y1; // pixels [x0,x1) x [y0,y1) that it can touch; empty when behind or outside
} gsf__disc_image;

typedef struct gsf__vis_counts { size_t rays, culled; } gsf__vis_counts;

typedef struct gsf__vis_job {
    const gsf_visibility_desc* desc;
    const gsf__discs* discs;
    const gsf__eye* eyes;
    size_t eye_count;
    uint8_t* seen;             // by place in the discs; what is set on entry gets no ray
    gsf__vis_counts* counts;   // per chunk of discs, so that their sum needs no atomics
    void* embree_scene;
    // z-buffer of one eye
    const gsf__eye* eye;
    int32_t width, height;     // of the buffer
    double scale_x, scale_y;   // buffer pixels per camera pixel
    float* depth;              // (height,width) camera depth of the nearest disc
    gsf__disc_image* images;   // (count)
} gsf__vis_job;

enum { GSF__VIS_CHUNK = 1024, GSF__VIS_BAND = 32, GSF__VIS_SIDE = 1024 };

// Frustum and grazing-angle tests; nonzero where a ray is worth shooting.
static int gsf__vis_sight(const gsf__vis_job* job, const gsf__eye* eye, size_t i, gsf__sight* out) {
    const float* sphere = job->discs->spheres + 4 * i;
    const float* normal = job->discs->normals + 3 * i;
    const double* m = eye->camera.w2c;
    double d[3];
    for (int k = 0; k < 3; k++) d[k] = (double)sphere[k] - eye->center[k];
    for (int r = 0; r < 3; r++) out->camera[r] = m[r] * d[0] + m[4 + r] * d[1] + m[8 + r] * d[2];
    if (!(out->camera[2] > 0.0)) return 0;
    out->u = eye->camera.fx * out->camera[0] / out->camera[2] + eye->camera.cx;
    out->v = eye->camera.fy * out->camera[1] / out->camera[2] + eye->camera.cy;
    if (!(out->u >= 0.0 && out->v >= 0.0 && out->u < eye->camera.width && out->v < eye->camera.height)) return 0;
    out->distance = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int k = 0; k < 3; k++) out->direction[k] = d[k] / out->distance;
    const double cosine = out->direction[0] * (double)normal[0] + out->direction[1] * (double)normal[1] +
                          out->direction[2] * (double)normal[2];
    return fabs(cosine) >= (double)job->desc->min_grazing_cos;
}

// How far along its ray before the point something must be to hide it.
static double gsf__vis_slack(const gsf__vis_job* job, size_t i) {
    return (double)(job->desc->tolerance * job->discs->spheres[4 * i + 3]);
}

// Pixels of [0,size) whose centres lie between the projections of c - e and c + e, z between z0 and z1 (both > 0).
static void gsf__vis_span(double c, double e, double z0, double z1, double focal, double center, int32_t size,
                          int32_t* begin, int32_t* end) {
    const double lo = focal * (c - e) / (c - e < 0.0 ? z0 : z1) + center - 0.5;
    const double hi = focal * (c + e) / (c + e < 0.0 ? z1 : z0) + center - 0.5;
    *begin = lo <= 0.0 ? 0 : lo >= size ? size : (int32_t)ceil(lo);
    *end = hi < 0.0 ? 0 : hi >= size - 1 ? size : (int32_t)floor(hi) + 1;
}

static void gsf__vis_project_chunk(void* arg, size_t chunk, int worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const gsf_camera* camera = &job->eye->camera;
    const double* m = camera->w2c;
    const size_t first = chunk * GSF__VIS_CHUNK;
    for (size_t i = first; i < job->discs->count && i < first + GSF__VIS_CHUNK; i++) {
        const float *sphere = job->discs->spheres + 4 * i, *normal = job->discs->normals + 3 * i;
        gsf__disc_image* image = job->images + i;
        double d[3], c[3], n[3], e[3];
        for (int k = 0; k < 3; k++) d[k] = (double)sphere[k] - job->eye->center[k];
        const double radius = (double)sphere[3];
        for (int r = 0; r < 3; r++) {
            c[r] = m[r] * d[0] + m[4 + r] * d[1] + m[8 + r] * d[2];
            n[r] = m[r] * (double)normal[0] + m[4 + r] * (double)normal[1] + m[8 + r] * (double)normal[2];
            e[r] = n[r] * n[r] < 1.0 ? radius * sqrt(1.0 - n[r] * n[r]) : 0.0; // half extent of the disc
            image->center[r] = (float)c[r];
            image->normal[r] = (float)n[r];
        }
        image->radius2 = (float)(radius * radius);
        image->x0 = image->x1 = image->y0 = image->y1 = 0;
        if (c[2] + e[2] <= 0.0) continue;
        if (c[2] - e[2] <= 1e-3 * radius) { // reaches behind the eye: anywhere
            image->x1 = job->width;
            image->y1 = job->height;
            continue;
        }
        gsf__vis_span(c[0], e[0], c[2] - e[2], c[2] + e[2], camera->fx * job->scale_x, camera->cx * job->scale_x,
                      job->width, &image->x0, &image->x1);
        gsf__vis_span(c[1], e[1], c[2] - e[2], c[2] + e[2], camera->fy * job->scale_y, camera->cy * job->scale_y,
                      job->height, &image->y0, &image->y1);
    }
}

static void gsf__vis_raster_band(void* arg, size_t band, int worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const gsf_camera* camera = &job->eye->camera;
    const int32_t begin = (int32_t)band * GSF__VIS_BAND;
    const int32_t end = begin + GSF__VIS_BAND < job->height ? begin + GSF__VIS_BAND : job->height;
    const float step_x = (float)(1.0 / (camera->fx * job->scale_x)), step_y = (float)(1.0 / (camera->fy * job->scale_y));
    const float cx = (float)(camera->cx * job->scale_x), cy = (float)(camera->cy * job->scale_y);
    for (int32_t y = begin; y < end; y++)
        for (int32_t x = 0; x < job->width; x++) job->depth[(size_t)y * (size_t)job->width + (size_t)x] = FLT_MAX;
    for (size_t i = 0; i < job->discs->count; i++) {
        const gsf__disc_image* d = job->images + i;
        if (d->x0 >= d->x1 || d->y0 >= end || d->y1 <= begin) continue;
        const float plane = d->normal[0] * d->center[0] + d->normal[1] * d->center[1] + d->normal[2] * d->center[2];
        for (int32_t y = d->y0 > begin ? d->y0 : begin; y < end && y < d->y1; y++) {
            const float dy = ((float)y + 0.5f - cy) * step_y;
            const float rest = d->normal[1] * dy + d->normal[2];
            float* row = job->depth + (size_t)y * (size_t)job->width;
            for (int32_t x = d->x0; x < d->x1; x++) {
                const float dx = ((float)x + 0.5f - cx) * step_x;
                const float z = plane / (d->normal[0] * dx + rest); // the pixel's ray (dx, dy, 1) meets the plane
                const float px = dx * z - d->center[0], py = dy * z - d->center[1], pz = z - d->center[2];
                if (z > 0.0f && z < row[x] && px * px + py * py + pz * pz <= d->radius2) row[x] = z;
            }
        }
    }
}

static void gsf__vis_zbuffer_chunk(void* arg, size_t chunk, int worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    gsf__vis_counts* counts = job->counts + chunk;
    const size_t first = chunk * GSF__VIS_CHUNK;
    for (size_t i = first; i < job->discs->count && i < first + GSF__VIS_CHUNK; i++) {
        gsf__sight sight;
        if (job->seen[i]) continue;
        if (!gsf__vis_sight(job, job->eye, i, &sight)) {
            counts->culled++;
            continue;
        }
        counts->rays++;
        int32_t x = (int32_t)(sight.u * job->scale_x), y = (int32_t)(sight.v * job->scale_y);
        if (x >= job->width) x = job->width - 1;
        if (y >= job->height) y = job->height - 1;
        const double before = sight.camera[2] * (1.0 - gsf__vis_slack(job, i) / sight.distance);
        job->seen[i] = !((double)job->depth[(size_t)y * (size_t)job->width + (size_t)x] < before);
    }
}

// Ray test without Embree: all discs into a depth buffer per eye, 1024 pixels on the longer side.
static gsf_result gsf__vis_by_zbuffer(gsf_context* ctx, gsf__vis_job* job, double* build_seconds) {
    gsf_result result = GSF_OK;
    const size_t chunks = (job->discs->count + GSF__VIS_CHUNK - 1) / GSF__VIS_CHUNK;
    job->images = (gsf__disc_image*)gsf_alloc(ctx, job->discs->count ? job->discs->count : 1, sizeof *job->images);
    job->depth = (float*)gsf_alloc(ctx, (size_t)GSF__VIS_SIDE * GSF__VIS_SIDE, sizeof(float));
    if (!job->images || !job->depth) result = GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; result == GSF_OK && i < job->eye_count; i++) {
        const double start = gsf__vis_seconds();
        const gsf_camera* camera = &job->eyes[i].camera;
        job->eye = job->eyes + i;
        const int64_t w = camera->width, h = camera->height, side = w > h ? w : h;
        job->width = (int32_t)((w * GSF__VIS_SIDE + side - 1) / side);
        job->height = (int32_t)((h * GSF__VIS_SIDE + side - 1) / side);
        job->scale_x = (double)job->width / (double)w;
        job->scale_y = (double)job->height / (double)h;
        gsf__parallel_for(ctx, chunks, gsf__vis_project_chunk, job);
        gsf__parallel_for(ctx, (size_t)((job->height + GSF__VIS_BAND - 1) / GSF__VIS_BAND), gsf__vis_raster_band, job);
        *build_seconds += gsf__vis_seconds() - start;
        gsf__parallel_for(ctx, chunks, gsf__vis_zbuffer_chunk, job);
        result = gsf__check_cancel(ctx);
    }
    gsf_free(ctx, job->images);
    gsf_free(ctx, job->depth);
    return result;
}

#ifdef GSF_USE_EMBREE
static gsf_result gsf__vis_by_embree(gsf_context* ctx, gsf__vis_job* job, double* build_seconds);
#endif

static void gsf__vis_by_tracks(const gsf_scene* scene, const uint8_t* chosen, uint8_t* keep) {
    for (size_t i = 0; i < scene->point_count; i++)
        for (size_t t = scene->track_begin[i]; t < scene->track_begin[i + 1] && !keep[i]; t++)
            keep[i] = chosen[scene->track_views[t]];
}

static gsf_result gsf__vis_by_rays(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                   const gsf_visibility_desc* desc, uint8_t* keep, gsf_visibility_stats* stats) {
    gsf__discs discs;
    gsf__vis_job job;
    memset(&job, 0, sizeof job);
    gsf__eye* eyes = (gsf__eye*)gsf_alloc(ctx, view_count, sizeof *eyes);
    if (!eyes) return GSF_ERROR_OUT_OF_MEMORY;
    double origin[3] = {0.0, 0.0, 0.0};
    for (size_t i = 0; i < view_count; i++) {
        eyes[i].camera = scene->views[views[i]].camera;
        gsf_camera_center(&eyes[i].camera, eyes[i].center);
        for (int k = 0; k < 3; k++) origin[k] += eyes[i].center[k] / (double)view_count;
    }
    for (size_t i = 0; i < view_count; i++)
        for (int k = 0; k < 3; k++) eyes[i].center[k] -= origin[k];

    double start = gsf__vis_seconds();
    gsf_result result = gsf__discs_make(ctx, scene, origin, desc, &discs);
    stats->seconds_normals = gsf__vis_seconds() - start;
    if (result != GSF_OK) goto cleanup;
    {
        const size_t chunks = (discs.count + GSF__VIS_CHUNK - 1) / GSF__VIS_CHUNK;
        result = GSF_ERROR_OUT_OF_MEMORY;
        job.seen = (uint8_t*)gsf_alloc(ctx, discs.count ? discs.count : 1, 1);
        job.counts = (gsf__vis_counts*)gsf_alloc_zeroed(ctx, chunks ? chunks : 1, sizeof *job.counts);
        if (!job.seen || !job.counts) goto cleanup;
        for (size_t i = 0; i < discs.count; i++) job.seen[i] = keep[discs.rows[i]];
        job.desc = desc;
        job.discs = &discs;
        job.eyes = eyes;
        job.eye_count = view_count;
        start = gsf__vis_seconds();
#ifdef GSF_USE_EMBREE
        if (!desc->use_zbuffer) {
            stats->used_embree = 1;
            result = gsf__vis_by_embree(ctx, &job, &stats->seconds_build);
        } else
#endif
            result = gsf__vis_by_zbuffer(ctx, &job, &stats->seconds_build);
        stats->seconds_rays = gsf__vis_seconds() - start - stats->seconds_build;
        if (result != GSF_OK) goto cleanup;
        for (size_t i = 0; i < chunks; i++) {
            stats->rays += job.counts[i].rays;
            stats->culled += job.counts[i].culled;
        }
        for (size_t i = 0; i < discs.count; i++) {
            stats->by_rays += job.seen[i] && !keep[discs.rows[i]];
            keep[discs.rows[i]] = job.seen[i];
        }
        if (discs.count < scene->point_count)
            gsf_log(ctx, GSF_LOG_WARNING, "visible points: %zu points with a non-finite coordinate get no ray",
                    scene->point_count - discs.count);
    }
cleanup:
    gsf_free(ctx, job.seen);
    gsf_free(ctx, job.counts);
    gsf__discs_destroy(ctx, &discs);
    gsf_free(ctx, eyes);
    return result;
}

GSF_API gsf_result gsf_splat_visible_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                            size_t view_count, const gsf_visibility_desc* desc, uint8_t* keep,
                                            gsf_visibility_stats* stats) {
    gsf_visibility_stats counted;
    memset(&counted, 0, sizeof counted);
    if (stats) *stats = counted;
    if (scene->point_count == 0) return GSF_OK;
    const gsf_visibility_desc d = gsf__visibility_desc_defaults(desc);
    GSF__TRY(gsf__visibility_check(ctx, scene, views, view_count, &d));
    memset(keep, 0, scene->point_count);
    counted.points = scene->point_count;
    gsf_result result = GSF_OK;
    if (d.method != GSF_VISIBILITY_RAYS) {
        uint8_t* chosen = (uint8_t*)gsf_alloc_zeroed(ctx, scene->view_count ? scene->view_count : 1, 1);
        if (!chosen) return GSF_ERROR_OUT_OF_MEMORY;
        for (size_t i = 0; i < view_count; i++) chosen[views[i]] = 1;
        gsf__vis_by_tracks(scene, chosen, keep);
        gsf_free(ctx, chosen);
        for (size_t i = 0; i < scene->point_count; i++) counted.by_tracks += keep[i];
    }
    if (d.method != GSF_VISIBILITY_TRACKS && view_count)
        result = gsf__vis_by_rays(ctx, scene, views, view_count, &d, keep, &counted);
    if (result != GSF_OK) {
        memset(keep, 0, scene->point_count);
        return result;
    }
    for (size_t i = 0; i < scene->point_count; i++) counted.kept += keep[i];
    if (stats) *stats = counted;
    return GSF_OK;
}

// ---- >>embree ------------------------------------------------------------------

#ifdef GSF_USE_EMBREE

static void gsf__vis_embree_chunk(void* arg, size_t chunk, int worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    gsf__vis_counts* counts = job->counts + chunk;
    const size_t first = chunk * GSF__VIS_CHUNK;
#if RTC_VERSION_MAJOR < 4
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    context.flags = RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
#endif
    for (size_t i = first; i < job->discs->count && i < first + GSF__VIS_CHUNK; i++)
        for (size_t e = 0; e < job->eye_count && !job->seen[i]; e++) {
            gsf__sight sight;
            if (!gsf__vis_sight(job, job->eyes + e, i, &sight)) {
                counts->culled++;
                continue;
            }
            counts->rays++;
            const double reach = sight.distance - gsf__vis_slack(job, i);
            if (!(reach > 0.0)) {
                job->seen[i] = 1;
                continue;
            }
            struct RTCRay ray; // from the eye, so that the point's own disc lies behind the ray's end
            memset(&ray, 0, sizeof ray);
            ray.org_x = (float)job->eyes[e].center[0];
            ray.org_y = (float)job->eyes[e].center[1];
            ray.org_z = (float)job->eyes[e].center[2];
            ray.dir_x = (float)sight.direction[0];
            ray.dir_y = (float)sight.direction[1];
            ray.dir_z = (float)sight.direction[2];
            ray.tfar = (float)reach;
            ray.mask = 0xffffffffu;
#if RTC_VERSION_MAJOR < 4
            rtcOccluded1((RTCScene)job->embree_scene, &context, &ray);
#else
            rtcOccluded1((RTCScene)job->embree_scene, &ray, NULL);
#endif
            job->seen[i] = ray.tfar >= 0.0f; // -inf where something is hit
        }
}

static gsf_result gsf__vis_by_embree(gsf_context* ctx, gsf__vis_job* job, double* build_seconds) {
    const double start = gsf__vis_seconds();
    gsf_result result = GSF_OK;
    RTCScene scene = NULL;
    RTCGeometry geometry = NULL;
    RTCDevice device = rtcNewDevice("threads=1,set_affinity=0"); // builds on the calling thread; rays run on the host's
    if (!device)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "Embree: no device (error %d)", (int)rtcGetDeviceError(NULL));
    geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_ORIENTED_DISC_POINT);
    scene = rtcNewScene(device);
    if (geometry && scene) {
        rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT4, job->discs->spheres, 0,
                                   4 * sizeof(float), job->discs->count);
        rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_NORMAL, 0, RTC_FORMAT_FLOAT3, job->discs->normals, 0,
                                   3 * sizeof(float), job->discs->count);
        rtcCommitGeometry(geometry);
        rtcAttachGeometry(scene, geometry);
        rtcCommitScene(scene);
    }
    const enum RTCError error = rtcGetDeviceError(device);
    if (error != RTC_ERROR_NONE) {
        result = gsf_fail(ctx, error == RTC_ERROR_OUT_OF_MEMORY ? GSF_ERROR_OUT_OF_MEMORY : GSF_ERROR_UNSUPPORTED,
                          "Embree: error %d while %zu discs are built", (int)error, job->discs->count);
    } else {
        *build_seconds = gsf__vis_seconds() - start;
        job->embree_scene = scene;
        gsf__parallel_for(ctx, (job->discs->count + GSF__VIS_CHUNK - 1) / GSF__VIS_CHUNK, gsf__vis_embree_chunk, job);
        result = gsf__check_cancel(ctx);
    }
    if (geometry) rtcReleaseGeometry(geometry);
    if (scene) rtcReleaseScene(scene);
    rtcReleaseDevice(device);
    return result;
}

#endif // GSF_USE_EMBREE

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
