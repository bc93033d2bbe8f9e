/* gsfixer_splat.h - 3D Gaussian Splatting on the CPU: scenes, splats, rendering with gradients, training, repair
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       #define GSFIXER_SPLAT_IMPLEMENTATION   // in one file; or GSFIXER_IMPLEMENTATION for everything included
       #include "gsfixer_splat.h"             // includes gsfixer.h and gsfixer_traj.h

   WHAT IT DOES NOT DO
       It estimates no camera poses, and it does not use the GPU. It knows no neural network: a restorer is a struct of
       functions (gsf_restorer in gsfixer.h), of which gsfixer_nn.h provides one.

   CONVENTIONS (in addition to those of gsfixer.h)
       A splat is mean, log-scale, raw quaternion wxyz (normalised when used; zero = identity), opacity logit and
       SH coefficients (K,3) with K = (degree + 1)^2, the 3DGS parametrisation:
           Sigma = R diag(exp(log_scale))^2 R^T,  opacity = sigmoid(logit),  colour = max(0, SH(direction) + 0.5)
       Means are float32 relative to a double origin, so georeferenced scenes keep their precision.
       A desc must be zeroed before use; zero selects the default of every field. Where zero itself is a legal value (a
       learning rate, a weight, a threshold), a negative value stands for it: lr_opacity = -1 trains no opacity. A resolved
       desc, as the trainer returns it, has the zero. The large ones begin and end with a canary that stays zero: a desc
       that was not zeroed is refused with GSF_ERROR_INVALID_ARGUMENT.

   CONFIGURATION (define before the implementation)
       GSF_USE_ZSTD         reads and writes version 4 of .spz (link zstd)
       GSF_USE_EMBREE       traces the rays of the visible-point filter with Embree (link embree3 or embree4); without it
                            the same discs are projected into a z-buffer, with the same result
       GSF_EMBREE_INCLUDE   default <embree4/rtcore.h> if available, else <embree3/rtcore.h>

   DATA FLOW
       photos, COLMAP model or transforms.json                 .ply .splat .spz .glb
             | gsf_splat_load_scene                                  ^ gsf_splat_save
             v                                                       | gsf_splat_load
         gsf_scene ---- gsf_splat_make_initial_splats -------> gsf_splats ---- gsf_splat_render ----> colour, depth, alpha
             |            visible points, dense stereo             |
             | gsf_splat_load_train_views                          |
             v                                                     v
         gsf_train_view[] --------------------------------> gsf_trainer <------ restored views, weight lambda -----.
                                                                   |                                               |
                                                                   | gsf_splat_render_trainer                      |
                                                                   v                                               |
         gsf_fixer:  path (gsfixer_traj.h) ------> frames of a window: colour, depth, alpha ------> gsf_restorer --'
                     photos -> stereo, exposure (once) -> scores (every round) -> what they show in a frame -^  (>>carry)

   STEP BY STEP
       gsf_splat_load_scene(&ctx, "scene", NULL, &scene);                                // cameras and points
       gsf_splat_load_train_views(&ctx, &scene, NULL, scene.view_count, &views);         // photos
       gsf_splat_make_initial_splats(&ctx, &scene, NULL, scene.view_count, NULL, &start, NULL);   // points -> splats
       desc = gsf_splat_resolve_few_view_desc(&scene, scene.view_count, GSF_QUALITY_BALANCED);
       gsf_splat_make_warp(&ctx, &warp);                                                 // or your own gsf_restorer
       gsf_splat_make_fixer(&ctx, &desc, views, scene.view_count, &start, &warp, &fixer);
       while (stats.stage != GSF_FIX_DONE) gsf_splat_step_fixer(&ctx, fixer, &stats);    // train, plan, restore
       gsf_splat_save(&ctx, "splats.ply", gsf_splat_get_trained(gsf_splat_get_trainer(fixer)), NULL);
       Each of these returns a result to be checked; README.md has the complete program. To train without repair, use
       gsf_splat_make_trainer with desc.train and call gsf_splat_step_trainer.

   A TRAINING STEP (gsf_splat_step_trainer), by section
       >>project    splats -> screen-space records: centre, conic, colour, tile rectangle
       >>bin        records -> per tile, a list sorted by depth
       >>raster forward, >>loss, >>raster backward    per tile and pixel: blend; L1 + SSIM; gradients of the records
       >>project backward    gradients of the records -> gradients of the splats
       >>adam       optimizer step; >>densify    every densify_interval steps: clone, split, prune (or MCMC)

   WHERE TO ADD
       a regulariser    its weight: a field of gsf_train_desc and a row of gsf__train_fields (raise GSF__TRAIN_FIELDS);
                        a default other than zero: gsf__train_desc_defaults, or gsf_splat_resolve_few_view_desc for few
                        views. In examples: `settings`, --regularize (gsfix_fix.c), `switches` (gsfix_report.c).
                        On parameters: gsf__penalty_job and gsf__penalty_chunk in >>trainer, and in gsf__trainer_update
                        the condition under which they run. With lazy_adam, they must not write gradients of SH.
                        On the image: beside gsf__depth_smoothness in >>loss, called by gsf__trainer_pass. Terms are
                        multiplied by `scale` and added to d_color after gsf__loss; gsf__depth_smoothness overwrites
                        d_depth, so that a second depth term adds to it afterwards. Depth is only rendered and
                        backpropagated if `smooth` is set there. New image buffers: gsf__trainer_reserve_images,
                        gsf_splat_destroy_trainer.
                        Tests: test_regularisers, busy_desc and the bad values in tests/test_trainer.c; the names in
                        tests/test_gsfix.sh
       a camera model   a row of gsf__lens_models in >>colmap, at the index that is COLMAP's model id; its parameters are
                        the focal lengths, cx, cy, then those of gsf__lens.k that it names. If its formula is new, also
                        gsf__lens_kind, gsf__lens_fault (legal values), gsf__lens_from_params (unless it is a pinhole
                        with all zeros) and, in >>undistort, gsf__lens_distort and, for constants that it needs,
                        gsf__rectify_make. For transforms.json: gsf__transforms_lens_kind and the names of parameters,
                        gsf__transforms_keys, in the order of gsf__transforms_add_camera. The list at
                        gsf_splat_load_scene. Tests: reference_distort and test_lenses, which counts through the ids (17
                        is refused), in tests/test_scene.c
       a file format    gsf_splat_type, a reader and a writer in >>formats
       a restorer       the host's own: fill in a gsf_restorer (gsfixer.h, "restorer interface"); gsf__open_references and
                        gsf__restore_or_skip in >>fixer make the calls. A built-in one: gsf_splat_make_NAME,
                        declared under "restorers", in a section like >>warp; its destroy_fn releases what it made. In
                        examples/gsfix.c the help of --restorer, gsfix_check_restorer, gsfix_make_restorer and, if
                        `gsfix restore` can lack its inputs, a check like check_warp_clip. The list in
                        README.md. Tests: tests/test_fixer.c, tests/test_gsfix.sh
       what photos show in a frame    a member of gsf_carried (gsfixer.h), its place in gsf__list_carried, and in >>carry
                        gsf__carry_row, which fills it in. What makes a pixel more or less certain: gsf__carry_score_row.
                        Tests: tests/test_carry.c
       a start          gsf_initial_kind, in >>few views

   ERRORS      As in gsfixer.h. Loaders report file and position and return only checked data; splats, pixels and gradients
               that are not finite are dropped or neutralised and counted (gsf_train_stats.rejected). A step that fails,
               because it was cancelled or is out of memory, changes nothing and may be repeated.
   MEMORY      Everything comes from the context's allocator, except scratch memory of Embree and stb. A trainer takes about
               1 kB per splat of SH degree 3 and, per pixel of a photo, 3 bytes (u8) or 12 (f32), and 4 more with a weight.
               The repair loop holds no other copy: while a round begins the restorer is shown photos as floats (with the
               splats' render and depth 28 bytes per pixel). For `warp`, and any restorer that asks for carried photos, it
               keeps 20 bytes per pixel of the photos until the round ends (29 if they are not 8-bit or have masks; as much
               again for `warp` until its first window), and until the run ends 4 bytes per pixel of their depth maps, at
               most 320 pixels long; a frame takes 4 bytes per pixel and reference, 52 more if it is handed out. Stereo, once
               per run, takes 80 bytes per pixel of its working size while it runs.
               A restored frame takes 7 bytes per pixel while it is trained on; one of `warp` that is mixed in takes 16 until
               the round ends.
               Buffers grow and are kept, so that rendering and training allocate only when the splats become more.
   THREADS     An object serves one thread at a time, together with the context of the call. Work inside a call is split
               through the parallel hook; results are bit-identical for any number of workers. To render while another
               thread trains, export a copy of the splats and use a rasterizer and a context of its own.
   STACK       With gcc 12 at -O2 the largest frames are 16 KiB on the calling thread (CRC-32 of checkpoints) and 11 KiB
               on workers (rasterizer). Give the calling thread 256 KiB and workers 64 KiB; workers that also run the
               convolutions of gsfixer_nn.h (frames of 32 KiB) 128 KiB.
   SECTIONS    >>splats >>order >>ply >>formats >>colmap >>transforms >>undistort >>scene >>neighbours >>visibility
               >>embree >>stereo >>rasterizer state >>project >>depth order >>bin >>raster forward >>raster backward
               >>project backward >>render >>loss >>adam >>densify >>trainer >>carry >>warp >>seen mask >>fixer >>few views
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
    int32_t antialiased;    // made for gsf_render_desc.antialiased; informative, stored in .spz files only
    float background[3];    // colour behind the splats in training; informative, stored in .ply files only
    double origin[3];       // world position that the means are relative to
    float* means;           // (count,3) relative to origin
    float* log_scales;      // (count,3)
    float* quats;           // (count,4) w x y z, raw
    float* opacity_logits;  // (count)
    float* sh;              // (count,K,3), coefficient-major, RGB last
    uint32_t* ids;          // (count) stable unique identifiers
    void* owned;            // memory to free; NULL if the arrays belong to the caller
} gsf_splats;

// Number of SH coefficients per channel of a degree: (degree + 1)^2.
GSF_API int32_t gsf_splat_count_sh(int32_t sh_degree);
// Zeroed splats with ids 0..count-1.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make(gsf_context* ctx, size_t count, int32_t sh_degree, gsf_splats* out);
GSF_API void gsf_splat_destroy(gsf_context* ctx, gsf_splats* splats);

// Sorts by the Morton order of the means: neighbours in space become neighbours in memory, which at a million splats
// saves a sixth of a training step. Sort before making a trainer, which keeps the order and appends. Renders are
// unchanged except for the order of splats at equal depth.
GSF_API GSF_NODISCARD gsf_result gsf_splat_sort(gsf_context* ctx, gsf_splats* splats);

/* Splat files. The format is chosen by the extension (.ply, .splat, .spz, .glb, case-insensitive); files with another
   extension are recognised by content if they are PLY, SPZ or GLB (.splat has no magic number).
       .ply    The standard 3DGS PLY: columns are found by name; ascii and both endians, float and double are read.
               Origin: zero, or the rounded centre if coordinates are large (centre beyond 1e5 or beyond 1000 times the
               extent; both are medians of samples and so robust against stray splats). A header with more rows than fit
               in the file is an error. Written as binary little-endian float32, as by Inria's code; x y z become double
               if they are large by the loader's rule, since float32 would lose precision (otherwise they stay float32,
               whatever the origin, so that every viewer can read the file).
       .splat  32 bytes per splat: float32 positions and scales, 8-bit colour, opacity and quaternion. SH bands above 0
               are lost. Errors: scales 1e-6 relative, colour and opacity 0.5/255, quaternion components 0.012.
       .spz    Niantic's SPZ: gzip of 20 (SH degree 0) to 65 bytes per splat; version 4 packs each array with zstd, whose
               memory does not come from the context. Versions 1 to 4 are read, 2 to 4 written.
               Errors: positions half a step (2^-12; finer if the median scale is below 2^-7, coarser if a coordinate
               exceeds 2047), log-scales 1/32 within -10..5.94, opacity 0.5/255, colour 0.5/255/0.15 as coefficient, SH
               4.5/128 (band 1) and 8.5/128 (above) within -1..1, quaternion components 0.002 (version 2: up to 0.15 for
               small w). Axes are converted to and from SPZ's (y and z negated), as Niantic's library does. Extensions
               and SH band 4 are ignored with a warning. GSF_ERROR_UNSUPPORTED: version 4 without GSF_USE_ZSTD; in gzip
               more than 2^30 bytes of content to write (16 million splats of degree 3), 2^31 to read, and reading at all
               under GSF_NO_STB.
       .glb    Binary glTF 2.0 with KHR_gaussian_splatting as ratified: floats, 64 (SH degree 0) to 244 bytes per splat,
               and COLOR_0 for viewers without splats. The origin becomes the node's translation, so that positions keep
               their precision. Axes are converted to and from glTF's (x and y negated). All primitives of the default
               scene are read, floats, bytes or shorts; their nodes' rotations, translations and uniform scales are
               applied (SH coefficients keep their axes, as the extension says). Files of early writers, which hold
               logarithms of scales, are recognised. GSF_ERROR_UNSUPPORTED: compression, other files' buffers; more than
               2^32 bytes. GSF_ERROR_DEGENERATE: no splats to write, as glTF has no empty arrays.
   Only .glb stores an origin; else world positions are written. For .splat and .spz, positions whose quantization is coarse
   relative to the splats (more than a quarter of the median scale) cause a warning and positions out of range an error;
   with `local` the means are written without the origin. Rows keep their order; ids are lost and become the row numbers.
   Splats with a NaN or infinite value are dropped, both when writing and when reading, and counted in a warning. An
   opacity of 0 or 1 is read as 0.001 or 0.999, since the logit must be finite. Memory is proportional to the content; a
   file that claims more content than can be compressed into it (DEFLATE: 1032 times its size; zstd: 1024 times) is refused
   in advance. */
typedef enum gsf_splat_type { GSF_SPLAT_AUTO = 0, GSF_SPLAT_PLY, GSF_SPLAT_SPLAT, GSF_SPLAT_SPZ, GSF_SPLAT_GLB } gsf_splat_type;

typedef struct gsf_splat_save_desc {
    gsf_splat_type type;  // AUTO: by the extension, which must then be one of the four
    int32_t local;        // write positions relative to splats->origin, which the file does not store
    int32_t spz_version;  // 2 to 4; 0 = 3, which all maintained readers support: one byte more per splat and a tenth of
                          // the rotation error (not visible for compact splats). Use 2 for readers from before July 2025
                          // and for glTF's KHR_gaussian_splatting_compression_spz_2; 4 has the values of 3
} gsf_splat_save_desc;

// Any of the formats.
GSF_API GSF_NODISCARD gsf_result gsf_splat_load(gsf_context* ctx, const char* path, gsf_splats* out);
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse(gsf_context* ctx, const char* name, const void* data, size_t size,
                                                 gsf_splats* out);
// desc: NULL = all default. format appends to `out`, which starts zeroed; name: for the type and for texts.
GSF_API GSF_NODISCARD gsf_result gsf_splat_save(gsf_context* ctx, const char* path, const gsf_splats* splats,
                                                const gsf_splat_save_desc* desc);
GSF_API GSF_NODISCARD gsf_result gsf_splat_format(gsf_context* ctx, const char* name, const gsf_splats* splats,
                                                  const gsf_splat_save_desc* desc, gsf_buffer* out);

// ---- scenes --------------------------------------------------------------------

typedef struct gsf_scene_view {
    char* name;         // image file name relative to the image folder
    uint32_t image_id;  // COLMAP's
    gsf_camera camera;  // pinhole camera of the undistorted, resized image
    gsf_image image;    // u8 RGB; data is NULL until gsf_splat_load_view_image
    gsf_image weight;   // u8, 1 channel, of the image's size: weight of each pixel, 255 = full, 0 = ignored (the photo's
                        // alpha times its mask); data is NULL if all have full weight
} gsf_scene_view;

typedef struct gsf_scene {
    size_t view_count;
    gsf_scene_view* views;  // sorted by name (bytes)
    size_t point_count;
    double* points;         // (point_count,3) world
    uint8_t* colors;        // (point_count,3)
    uint64_t* point_ids;    // (point_count) COLMAP's
    size_t* track_begin;    // (point_count+1) into track_views; all zero if the scene has no tracks
    uint32_t* track_views;  // indices into views, ascending and unique within a point
    double origin[3];       // mean camera centre, the origin for splats made from this scene
    size_t missing_count;   // photos that the model lists but that do not exist; their views are left out
    char* folder;           // as given to the loader
    void* state;            // private: source cameras and sizes for gsf_splat_load_view_image
} gsf_scene;

typedef struct gsf_scene_desc {
    int32_t factor;    // images are 1/factor of the model's size: images_<factor>/ if present, else resized; 0 = 1
    int32_t max_size;  // shrink so that the longer side is at most this many pixels; 0 = no limit; excludes factor
    int32_t no_masks;  // ignore masks/ and the photos' alpha: all pixels have full weight
} gsf_scene_desc;

// Reads a COLMAP folder (images/ or images_<factor>/, sparse/0/ or sparse/ with {cameras,images,points3D}.{bin,txt}) or
// a nerfstudio / instant-ngp transforms.json (its folder or the file itself; points from its ply_file_path, else none).
// Only the headers of images are read, since a COLMAP camera is rescaled to the actual image size, as in the COLMAP
// parser of the GSFixer release. Views whose photo is missing are left out with a warning and counted; a photo that
// exists but cannot be read is an error; photos are never enlarged. All camera models of COLMAP are supported (up to
// EUCM, version 4.1) except EQUIRECTANGULAR, whose panoramas have no pinhole image. Distorted ones become pinhole
// cameras: RADIAL and OPENCV models by OpenCV's getOptimalNewCameraMatrix (alpha 0) and crop, as in that parser;
// fisheye, FOV, DIVISION and EUCM models by the smallest zoom, at most 75 degrees off axis, that shows no pixel from
// outside the photo. The rigs and frames that COLMAP writes since 3.12 are not needed, because images have their own
// poses. Track entries for unknown images and non-finite points are dropped with a warning. Image names that lead out
// of the folder ("..", absolute) are refused. Memory and time are proportional to the files.
GSF_API GSF_NODISCARD gsf_result gsf_splat_load_scene(gsf_context* ctx, const char* path, const gsf_scene_desc* desc,
                                                      gsf_scene* out);
typedef struct gsf_bytes {
    const void* data;
    size_t size;
    const char* name; // for error texts; NULL = the file's usual name
} gsf_bytes;

// The same from memory: contents of the three COLMAP files, binary or (is_text) text. `points` may be NULL. All images
// are kept, since there is no folder to search; sizes are those of the cameras after undistortion. View images are
// empty until gsf_splat_set_view_image.
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_colmap(gsf_context* ctx, int32_t is_text, const gsf_bytes* cameras,
                                                        const gsf_bytes* images, const gsf_bytes* points,
                                                        gsf_scene* out);
// transforms.json from memory; it must contain w and h. No points.
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_transforms(gsf_context* ctx, const gsf_bytes* json, gsf_scene* out);
// Path of a view's photo, including the scene's path; valid as long as the scene. NULL for scenes parsed from memory.
GSF_API const char* gsf_splat_get_view_path(const gsf_scene* scene, size_t view);
// Decodes, resizes (PIL bicubic) and undistorts one view's photo into view->image (kept if already present). Rows are
// undistorted in parallel. Only for scenes that were loaded from files.
// view->weight is the photo's alpha times its mask, masks/NAME.png or (as in COLMAP) masks/NAME.EXT.png for the photo
// images/NAME.EXT: an image of any size with the photo's aspect ratio, black where the photo is to be ignored. Colours
// are used as stored (straight alpha). Resizing and undistortion weight each pixel, so that colours of ignored pixels
// do not bleed into others.
GSF_API GSF_NODISCARD gsf_result gsf_splat_load_view_image(gsf_context* ctx, gsf_scene* scene, size_t view);
// The same for a photo decoded by the host: any dtype and layout, 1 to 4 channels (the second of two or the fourth is
// alpha, which can also carry a mask), distorted as taken, of any size (it is resized to the camera's); one labelled
// GSF_COLOR_LINEAR is encoded as sRGB. The photo is borrowed for the call; an existing image and weight are replaced.
GSF_API GSF_NODISCARD gsf_result gsf_splat_set_view_image(gsf_context* ctx, gsf_scene* scene, size_t view,
                                                          const gsf_image* photo);
// Writes <folder>/sparse/0/{cameras,images,points3D}.bin; <folder>/sparse/0 must exist. Cameras are PINHOLE; tracks are
// kept, with projections in place of the measured 2D points, which a scene does not store. keep: NULL or one byte per
// point, zero = left out.
GSF_API GSF_NODISCARD gsf_result gsf_splat_save_colmap(gsf_context* ctx, const gsf_scene* scene, const uint8_t* keep,
                                                       const char* folder);
GSF_API void gsf_splat_destroy_scene(gsf_context* ctx, gsf_scene* scene);

// The papers' split of n views sorted by name: every test_every-th view, starting with the first, is a test view (0:
// none); train = round(linspace(0, m-1, K)) over the other m (half to even; with K > m views repeat, as in the GSFixer
// release). K = 0: all others. Counts are returned. train holds up to max(n, K) entries, test up to n; pointers may be
// NULL.
GSF_API void gsf_splat_split_views(size_t n, size_t test_every, size_t train_target, uint32_t* train,
                                   size_t* train_count, uint32_t* test, size_t* test_count);

// ---- visible-point filter ------------------------------------------------------

typedef enum gsf_visibility_method {
    GSF_VISIBILITY_BOTH = 0, // seen by track or by ray (default)
    GSF_VISIBILITY_TRACKS,   // the point's track contains one of the views, as in the GSFixer release
    GSF_VISIBILITY_RAYS,     // rays against points as oriented discs; with Embree, or by projecting the same discs
} gsf_visibility_method;

/* Every point is a disc: normal by PCA of its neighbours, radius proportional to their spacing. A point is occluded in a
   view if the discs on its ray have a total coverage above a limit: each disc hit at distance q from its centre adds 1 -
   (q / radius)^2, unless the point is less than `tolerance` radii (of the larger disc) behind it. On an evenly sampled
   plane, the defaults add up to about 7, so that a surface occludes even if half of its points are missing, while a
   stray point does not. The limit is `coverage`. If the scene has tracks, it is adjusted by three observations: whether
   the point's neighbours have the view in their tracks, as expected if they are visible; the distance of the view from
   the nearest other view in the point's track; and whether the view is behind the surface, relative to the views in the
   neighbours' tracks. Whether the point's own track contains the view is not used: that is the method of tracks, and
   recall against it remains a fair test. Measured (tests/test_visibility.c): balanced accuracy 0.94, 0.92 and 0.91 for
   three, six and nine views of eight ray-traced scenes together; recall against the tracks 0.96, 0.99 and 0.99 on real
   photos. */
typedef struct gsf_visibility_desc {
    gsf_visibility_method method;
    int32_t neighbours;    // for normals, default 12
    int32_t radius_neighbour; // disc radius = distance to this neighbour (at most 3 times the median), default 6
    float radius_scale;    // factor on that radius, default 1.4
    float tolerance;       // in radii, default 0.7; negative = 0: discs at any distance in front of the point count
    float coverage;        // default 2; smaller values occlude more; negative = 0: any disc occludes
    float min_grazing_cos; // |cos| between ray and normal below which no ray is traced, default 0.02; negative = 0
    int32_t use_zbuffer;   // project the discs and test depth at each point, even if Embree is compiled in
} gsf_visibility_desc;

typedef struct gsf_visibility_stats {
    size_t points, kept, by_tracks, by_rays;  // by_rays: kept by rays; points already kept by tracks are not traced
    size_t rays, culled;                      // rays traced; (point, view) pairs rejected without one
    double seconds_normals, seconds_build, seconds_rays;
    int32_t used_embree; // 0 also if Embree ran out of memory: the discs are then projected instead, with a warning
} gsf_visibility_stats;

// Sets keep[i] to 1 if at least one of the given views sees point i, else to 0. stats may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_splat_filter_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                                         size_t view_count, const gsf_visibility_desc* desc,
                                                         uint8_t* keep, gsf_visibility_stats* stats);

// Initial splats from points: scale = sqrt(mean squared distance to the 3 nearest kept points, at least 1e-7), opacity
// 0.1, SH dc from colour (create_from_pcd of Inria's 3DGS). keep: NULL or one byte per point. origin: NULL = zero. Ids
// are the rows of the points. Points with a non-finite coordinate are skipped and counted in a warning.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_from_points(gsf_context* ctx, const double* points,
                                                            const uint8_t* colors, size_t count, const uint8_t* keep,
                                                            int32_t sh_degree, const double origin[3], gsf_splats* out);

// ---- dense stereo --------------------------------------------------------------

/* Points on which the photos of a few posed views agree, by PatchMatch multi-view stereo, coarse to fine: every pixel of
   every view holds a plane (inverse depth and slope). Planes are propagated to neighbours and perturbed at random, and
   kept if they improve the match of the photo's window in the other views (weighted normalised cross-correlation, of
   colours while coarse and of grey at the finest level, with view weights per pixel). A pixel is accepted if its match is
   good and it passes a consistency check: the plane of at least one other view at the corresponding pixel leads back to
   it. Accepted pixels are merged over the views and thinned. Zero is the default of every field. Pixels are those of the
   working size. */
typedef struct gsf_dense_desc {
    uint64_t seed;
    int32_t max_size;        // longer side of the working images; larger photos are shrunk; 0 = 640
    int32_t levels;          // maximum number of pyramid levels; 0 = 3 (while at least 48 pixels are left)
    int32_t iterations;      // per level; 0 = 2. Two more at the coarsest level; half as many at the finest, followed by
                             // two that include the depth consistency of the views in the cost
    int32_t sources;         // other views that each view is matched with, at most 8; 0 = 4
    int32_t radius;          // of the matching window in pixels, at most 15; 0 = 5
    int32_t stride;          // between samples of the window; 0 = 2
    float color_sigma;       // grey levels of 255 at which a sample's weight falls to 1/e; 0 = 18
    float min_angle;         // minimum triangulation angle in degrees; 0 = 1, negative = 0
    float max_cost;          // maximum of 1 - correlation for a pixel and for those that confirm it; 0 = 0.35
    float max_cost_many;     // the same if one view more than required agrees; 0 = 0.5
    float max_reprojection;  // maximum forward-backward reprojection error in pixels; 0 = 1
    float max_depth_error;   // maximum relative difference of the two depths; 0 = 0.02
    float max_normal_angle;  // maximum angle between the two normals in degrees; 0 = 40
    int32_t min_consistent;  // number of other views that must agree; 0 = 1
    int32_t spacing;         // pixels between points, at least 1; 0 = 2
    size_t max_points;       // spacing is increased until at most this many are left; 0 = no limit
    int32_t skip_sparse;     // no points closer than `spacing` to a sparse point (of `keep`), so that both can be merged
    double depth_min, depth_max; // search range of the camera depth; 0 = from the sparse points and the camera poses
    int32_t want_maps;       // fill in `maps`
} gsf_dense_desc;

typedef struct gsf_dense_map { // one view
    uint32_t view;           // index into the scene's views
    gsf_camera camera;       // at the map's size
    float* depth;            // (height,width) camera depth at pixel centres where the views agree, else 0
    float* normals;          // (height,width,3) world, unit, towards the camera; 0 where depth is 0
} gsf_dense_map;

typedef struct gsf_dense_stats {
    size_t views, pairs;     // distinct views; ordered pairs compared
    size_t pixels, matched, consistent; // over all views: pixels with texture; with a good match; confirmed by other
                                        // views
    int32_t spacing;         // in effect
    double seconds_prepare, seconds_match, seconds_fuse;
} gsf_dense_stats;

typedef struct gsf_dense {
    size_t count;
    double* points;          // (count,3) world
    float* normals;          // (count,3) world, unit, towards the views
    uint8_t* colors;         // (count,3) mean of the views that agree
    float* confidence;       // (count) 1 - cost of the best view's pixel
    uint8_t* view_counts;    // (count) views that agree, at least 2
    size_t map_count;
    gsf_dense_map* maps;     // NULL unless want_maps
    void* owned;             // memory of all arrays
} gsf_dense;

// Views are indices into scene->views, whose images must be loaded (pixels with a weight below 128 neither yield nor
// confirm points); repeated views count once. keep: NULL or one byte per sparse point, zero = not used; sparse points
// only guide the search. With fewer than two distinct views, or without overlap, the result is GSF_OK with no points.
// stats may be NULL. Bit-identical for any number of workers and any instruction set.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_dense(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                                      size_t view_count, const uint8_t* keep,
                                                      const gsf_dense_desc* desc, gsf_dense* out,
                                                      gsf_dense_stats* stats);
GSF_API void gsf_splat_destroy_dense(gsf_context* ctx, gsf_dense* dense);

// ---- rendering -----------------------------------------------------------------

typedef enum gsf_footprint {
    GSF_FOOTPRINT_FULL = 0, // a splat reaches every pixel where its alpha is at least 1/255
    GSF_FOOTPRINT_OFFICIAL, // only the 16x16 tiles of its 3-sigma square, as in Inria's CUDA rasterizer
} gsf_footprint;

typedef enum gsf_gradient {
    GSF_GRADIENT_TRUE = 0,  // the exact derivative of the image
    GSF_GRADIENT_OFFICIAL,  // as in Inria's: ignores the 0.99 clamp of alpha; treats the clamped x/z as constant
} gsf_gradient;

typedef struct gsf_render_desc {
    uint32_t _start_canary;
    int32_t sh_bands;          // SH bands evaluated: degree + 1; 0 = all that are stored
    float background[3];
    gsf_footprint footprint;
    gsf_gradient gradient;
    int32_t antialiased;       // Mip-Splatting's 2D filter: opacity times sqrt(det/det_blurred)
    float near_plane;          // splats with camera depth <= this are culled; 0 = 0.2 (Inria's 3DGS)
    const uint8_t* hidden;     // NULL or one byte per splat: non-zero splats are not drawn (dropout)
    float opacity_scale;       // every opacity is multiplied by this; 0 = 1
    uint32_t _end_canary;
} gsf_render_desc;

typedef struct gsf_render_output { // images of the caller, all f32 of the camera's size; data NULL = not wanted
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

// Workspace of the rasterizer, which keeps the state of the last forward pass for the backward pass. Buffers only grow,
// so steady rendering does not allocate. A rasterizer serves one thread at a time and splits its work through the
// parallel hook.
typedef struct gsf_rasterizer gsf_rasterizer;
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_rasterizer(gsf_context* ctx, gsf_rasterizer** out);
GSF_API void gsf_splat_destroy_rasterizer(gsf_context* ctx, gsf_rasterizer* rasterizer);

// Renders splats from `camera`. Splats with a non-finite value are skipped.
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
// For each pixel of `camera`: 1 where its 3D point, taken from the depth of `splats` (a good model, say of all views), is
// seen by at least one of the other cameras (inside its image and not behind its own depth by more than 5 %), else 0.
// mask: u8, one channel, of the camera's size. Pixels with alpha below 0.5 are 0.
GSF_API GSF_NODISCARD gsf_result gsf_splat_render_seen_mask(gsf_context* ctx, const gsf_splats* splats,
                                                            const gsf_camera* camera, const gsf_camera* seeing,
                                                            size_t seeing_count, const gsf_image* mask);

// ---- training ------------------------------------------------------------------

typedef struct gsf_train_view {
    gsf_camera camera;
    gsf_image image;   // u8 or f32 RGB, same size as the camera; copied. Values beyond 0..1 count as 0 and 1 in the loss.
                       // An image labelled GSF_COLOR_LINEAR is encoded as sRGB, and its copy is f32
    gsf_image weight;  // 1 channel, u8 (255 = 1) or f32: per-pixel weight of the loss (a photo's mask or alpha, a
                       // restorer's confidence); data NULL = 1; copied. The loss is sum(weight * term) / (3 W H). A
                       // pixel of weight 0 is treated as outside the image: it has no error, and neither its colour
                       // nor the render there is read. Colours are not multiplied by alpha
} gsf_train_view;

typedef enum gsf_background { // the colour behind the splats in training
    GSF_BACKGROUND_GIVEN,     // `background`
    GSF_BACKGROUND_PHOTOS,    // the grey that is as bright as the photos are in the mean, by their weights; it then is
                              // `background`. What no photo shows is less wrong than with black
    GSF_BACKGROUND_RANDOM     // a new random colour in each step; other renders show `background`
} gsf_background;

// Zero = the value given beside each field, that of Inria's 3DGS; s = iterations / 30000. Negative = zero for all learning
// rates except lr_means_final, for lambda_ssim, densify_from, densify_grad, densify_scale and prune_opacity, and where a
// field says so.
typedef struct gsf_train_desc {
    uint32_t _start_canary;
    int32_t iterations;            // 30000
    uint64_t seed;
    int32_t coarse_until;          // 0; photos have half their size up to this iteration, which then takes less than half
                                   // of the time. Photos of less than 32 pixels a side are not halved
    int32_t sh_degree;             // degree to train; 0 = the splats' own
    int32_t sh_interval;           // 1000 s: iterations per additional SH band; bands that the splats already use stay
                                   // active
    float lr_means, lr_means_final;// 1.6e-4, 1.6e-6, both times extent, exponential decay over all iterations
    int32_t lr_means_delay_steps;  // 0; number of warm-up iterations of lr_means
    float lr_means_delay;          // initial factor of lr_means in the warm-up
    float lr_sh_dc, lr_sh_rest, lr_opacity, lr_scales, lr_quats; // 2.5e-3, 1.25e-4, 0.025, 5e-3, 1e-3
    float extent;                  // 1.1 * largest distance of a training camera from their mean; if the cameras
                                   // coincide, the median depth of the splats
    float lambda_ssim;             // 0.2; negative = 0: no SSIM term
    float background[3];           // colour behind the splats
    gsf_background background_kind;
    int32_t densify_from, densify_until; // 500 s, 15000 s (mcmc: 25000 s); densify_until < 0 = never, nor opacity resets
    int32_t densify_interval;      // 100, whatever s is
    float densify_grad;            // 2e-4
    int32_t densify_absolute;      // 0; 1: sum absolute gradients over the pixels (AbsGS; use densify_grad 4e-4 to 8e-4)
    float densify_scale;           // 0.01: clone below this fraction of extent, split above
    int32_t densify_shared;        // 0; 1: new splats share the opacity of the old one, so that they are together as opaque
                                   // as it was: 1 - sqrt(1 - opacity) each (Rota Bulo et al. 2024). A split puts two
                                   // splats half a standard deviation to either side along the longest axis, which
                                   // becomes 0.66 times as long. Renders change less, and there are fewer splats
    float prune_opacity;           // 0.005
    float prune_scale;             // 0.1 of extent, after the first opacity reset
    int32_t opacity_reset_interval;// 3000 s, but at least 1000, so that opacities recover in between; negative = never
    size_t max_splats;             // densification stops growing here; 0 = 2 million (mcmc: 1 million)
    int32_t mcmc;                  // 0; 1: densification as in "3DGS as Markov Chain Monte Carlo": splats below
                                   // prune_opacity are relocated to others, up to 5 % are added at a time until there
                                   // are max_splats, and noise is added to the means in every step. Nothing is pruned,
                                   // no opacity is reset; densify_grad, densify_absolute, densify_scale and
                                   // prune_scale have no effect
    float mcmc_noise;              // 5e5 with mcmc; negative = no noise
    gsf_render_desc render;        // footprint, gradient kind, antialiasing, near plane (0 = the smaller of 0.2 and 0.01
                                   // extent); background is taken from above; hidden, sh_bands, opacity_scale stay zero
    // regularisers for few views; zero = off
    float dropout;                 // share of splats hidden in a step, growing linearly from 0 to this; the others'
                                   // opacities are divided by 1 - share (DropGaussian)
    float opacity_decay;           // relative decay of every opacity per iteration (applied every 10; Binocular3DGS:
                                   // 0.005)
    float scale_penalty;           // weight of mean(exp(log_scale)) / extent; with mcmc zero = 0.01, negative = off
    float opacity_penalty;         // weight of mean(opacity); with mcmc zero = 0.01, negative = off
    float depth_smoothness;        // weight of edge-aware smoothness of rendered inverse depth (times extent)
    float sharpness;               // 0; above: steps are sharpness-aware, with means moved by this many pixels of the photo
                                   // against the loss (Foret et al. 2021; for splats FASR, arXiv 2511.17918): the gradient
                                   // is the mean of those before and after the move. Such a step takes twice the time
    int32_t sharpness_from;        // iteration after which they are; 0 = 3/4 of the iterations, negative = 0
    int32_t lazy_adam;             // 0; 1: the SH of splats that are not drawn are updated when they are drawn again, to
                                   // the same values up to rounding (5e-7 after 1000 steps); pays off if views see
                                   // little of the scene
    uint32_t _end_canary;
} gsf_train_desc;

typedef struct gsf_train_stats {
    int32_t iteration;     // just done, from 1
    size_t splats;
    double loss, l1, ssim; // of this step's photo, without regularisers
    double restored_loss;  // of this step's restored view, without its weight; 0 if there was none
    size_t rejected;       // non-finite initial splats, gradients and parameters dropped or neutralised so far
} gsf_train_stats;

typedef struct gsf_trainer gsf_trainer;

// The trainer copies views and splats (non-finite ones are dropped). Steps are deterministic: bit-identical for any
// number of workers. Each step uses one photo of a random permutation, reshuffled when exhausted, and, if there are
// restored views with a weight above 0, one restored view; both gradients enter one Adam step (splats that are not
// visible also move by their momentum). For densification, the gradients of photos and of restored views are averaged
// separately, and the larger mean is used.
// Memory: about 1 kB per splat of SH degree 3; per pixel of a photo 3 bytes (u8) or 12 (f32), and 4 more with a weight.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_trainer(gsf_context* ctx, const gsf_train_desc* desc,
                                                        const gsf_train_view* views, size_t view_count,
                                                        const gsf_splats* initial, gsf_trainer** out);
GSF_API void gsf_splat_destroy_trainer(gsf_context* ctx, gsf_trainer* trainer);
// The trainer's desc with all defaults, the extent and the near plane filled in. For display; not valid as input, because
// zero means default there (e.g. lambda_ssim is 0 here without an SSIM term).
GSF_API gsf_train_desc gsf_splat_get_trainer_desc(const gsf_trainer* trainer);
// Runs one iteration; GSF_ERROR_INVALID_ARGUMENT after the last one. A step that fails (cancelled, out of memory)
// changes nothing and may be repeated. stats may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_splat_step_trainer(gsf_context* ctx, gsf_trainer* trainer, gsf_train_stats* stats);
// Replaces the restored views; count 0 removes them. The weight of their loss, lambda, may be changed at any time.
GSF_API GSF_NODISCARD gsf_result gsf_splat_set_restored_views(gsf_context* ctx, gsf_trainer* trainer,
                                                              const gsf_train_view* views, size_t count);
GSF_API void gsf_splat_set_restored_weight(gsf_trainer* trainer, float lambda);
// Renders the current state. Call between steps.
GSF_API GSF_NODISCARD gsf_result gsf_splat_render_trainer(gsf_context* ctx, gsf_trainer* trainer,
                                                          const gsf_camera* camera, const gsf_render_output* out);
// A copy of the current splats.
GSF_API GSF_NODISCARD gsf_result gsf_splat_copy_trained(gsf_context* ctx, const gsf_trainer* trainer, gsf_splats* out);
// The current splats, borrowed until the next step or gsf_splat_parse_trainer.
GSF_API const gsf_splats* gsf_splat_get_trained(const gsf_trainer* trainer);
// Appends the complete state as chunks / restores it; training then continues bit-identically. The caller provides the
// same views and desc again (views in any order; a difference causes only a warning); the weight of the restored views
// is part of the state. parse takes a complete chunk file and checks it; if it is refused, the trainer is unchanged.
GSF_API void gsf_splat_format_trainer(gsf_context* ctx, const gsf_trainer* trainer, gsf_buffer* chunks);
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_trainer(gsf_context* ctx, gsf_trainer* trainer, const char* name,
                                                         const void* chunks, size_t size);

// ---- restorers -----------------------------------------------------------------

// Training-free restorer: shows in a frame what the reference photos show of it. Where other photos confirm depth and
// colour, the photos' colours replace the render; if there are six photos or more, only one that shows another depth, and
// the residual (photo - render at the photo's camera) is added in full to one that agrees; what lies behind the frame's own
// surface is then shown only where a photo looks through that surface. Where only the splats vouch for the depth, the
// residual is added with less weight and less confidence; where no reference sees a pixel, the render is kept with
// confidence 0. Floaters, identified by two references that see through them, are replaced by the photos behind them. Depths
// are those of stereo between the photos or, where it finds none, of the splats. Without renders of the references, colours
// are taken everywhere. Destroy with gsf_destroy_restorer.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_warp(gsf_context* ctx, gsf_restorer* out);

// ---- the repair loop -----------------------------------------------------------
/* Trains, and at certain iterations runs a round: sample a path, render it window by window, have the restorer repair the
   frames, and continue training on photos and repaired frames: L = L_recon + lambda * L_gen. The frames of a new round
   replace the old ones. Where the weight is below the larger of 1 and lambda, repaired frames have that one, in as many
   steps as make up for those without, which cost half as much. A frame covers a photo's full field of view, in pixels of a
   size of its own (frame_scale, max_pixels). If the restorer asks for it (limits.squash), it is rendered at the restorer's
   own size, with fx and fy scaled independently, and trained on with that camera; otherwise pixels stay square, the frame
   may lack or add a margin, and pixels beyond the photo's field of view are not trained on. The loop is a state machine that
   the host steps, so it can show, cancel, checkpoint or stop at any time.
       gsf_splat_make_fixer -> gsf_splat_step_fixer until stats.stage is GSF_FIX_DONE -> gsf_splat_copy_trained */

typedef struct gsf_fixer gsf_fixer;

typedef struct gsf_fix_desc {
    uint32_t _start_canary;
    gsf_train_desc train;         // for the whole run; train.iterations is the total number of steps
    gsf_traj_kind trajectory;     // zero: the paper's reference-guided path
    const double* points;         // (point_count,3) world points for the path's axes and depth; NULL = cameras only;
                                  // borrowed until the fixer is destroyed
    size_t point_count;
    const gsf_camera* path;       // (path_count) poses of the frames to repair in every round, in place of the
                                  // trajectory; NULL = the trajectory. Spread evenly over windows x window_frames: where
                                  // the counts differ, poses are left out or repeated. Frames have the first photo's
                                  // size and field of view. Borrowed until the fixer is destroyed
    size_t path_count;
    int32_t rounds;               // repair rounds, default 3; negative = none
    int32_t first_round;          // iteration after which the first round runs; 0 = about 1/3 of the iterations, shortly
                                  // before a densification
    int32_t last_round;           // the others are spread evenly up to this iteration; 0 = about 5/6, likewise
    int32_t windows;              // per round; 0 = one per training view, at least 2
    int32_t window_frames;        // 0 = the restorer's preferred count, else 17; changed to the nearest count that it
                                  // accepts
    float lambda;                 // weight of the restored views at the end of training, default what the restorer
                                  // prefers for this many photos, or 1; negative = 0
    float skip_psnr;              // skip windows whose render agrees with the warped references by this many dB, over the
                                  // pixels that the references explain; 0 = never skip
    float frame_scale;            // sides of the frames as a share of the photos', at most 1, default what the restorer
                                  // prefers, or 1. Not used if the restorer has a frame size of its own (limits.squash)
    float warp_weight;            // the loop's frames are the mean of the restorer's, with the weight 1, and those of `warp`,
                                  // with this one, each times the confidence of the pixel; default what the restorer
                                  // prefers, or 0; negative = 0. Not used if the restorer explains (`warp` does)
    int32_t max_pixels;           // larger frames are rendered smaller, with the same field of view, if the restorer
                                  // accepts smaller ones; 0 = no limit
    float auto_exposure;          // share of the exposure that the photos' camera would have chosen for a frame of
                                  // gsf_splat_restore_views, if the photos show that it chose by what it saw and the restorer
                                  // has photos carried; default 1; negative = 0: frames keep the exposure of the splats
    gsf_fixer* const* copies;     // (copy_count) trained fixers of the same views, with other seeds, to be joined; borrowed
    size_t copy_count;            // until the fixer is destroyed. See gsf_splat_make_fixer
    uint32_t _end_canary;
} gsf_fix_desc;

typedef enum gsf_fix_stage { GSF_FIX_TRAIN = 0, GSF_FIX_PLAN, GSF_FIX_RESTORE, GSF_FIX_DONE } gsf_fix_stage;

typedef struct gsf_fix_stats { // what the last step did
    gsf_fix_stage stage;
    gsf_train_stats train;            // TRAIN: of this step, else zero
    float lambda;                     // TRAIN: weight of the restored views, in the mean of the steps around this one
    int32_t round, rounds;            // 1-based round being planned or restored
    int32_t window, windows;          // likewise
    int32_t skipped;                  // windows skipped so far
    int32_t frame_count;              // RESTORE: number of frames in this window. The following are borrowed until the
                                      // next step
    const gsf_camera* cameras;        // of the frames
    const gsf_image *rendered, *restored, *confidence; // f32; restored is NULL where the window was skipped
    const int32_t* reference_index;   // per frame: the training view with the same pose, or -1
} gsf_fix_stats;

// Views and splats are copied; the restorer (NULL: plain training) is borrowed until the fixer is destroyed.
// The path of every round is sampled once: cameras that admit no path give GSF_ERROR_DEGENERATE before any
// training.
// With desc->copies, which err differently and so less together, the fixer joins them. It starts from all their splats, each so
// transparent that one of every copy are as opaque as one was (initial: NULL), and trains as the desc of one copy says, but for
// an eighth of its iterations, with slower means, no growth and no dropout. Its only round comes after the first step: the
// frames are what gsf_splat_restore_views makes of the copies; no window is skipped and `warp` not mixed in.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_fixer(gsf_context* ctx, const gsf_fix_desc* desc,
                                                      const gsf_train_view* views, size_t view_count,
                                                      const gsf_splats* initial, const gsf_restorer* restorer,
                                                      gsf_fixer** out);
GSF_API void gsf_splat_destroy_fixer(gsf_context* ctx, gsf_fixer* fixer);
// The loop's desc with defaults filled in, with `train` from gsf_splat_get_trainer_desc (rounds is 0 without a restorer). For
// display only, likewise.
GSF_API gsf_fix_desc gsf_splat_get_fixer_desc(const gsf_fixer* fixer);
// Runs one training iteration, plans a round, or restores one window. After an error or cancellation the fixer stays
// usable.
GSF_API GSF_NODISCARD gsf_result gsf_splat_step_fixer(gsf_context* ctx, gsf_fixer* fixer, gsf_fix_stats* stats);
// The fixer's trainer, for rendering and export.
GSF_API gsf_trainer* gsf_splat_get_trainer(const gsf_fixer* fixer);
// A filter on final renders: renders the trained splats for these cameras, all of the same size, and has the fixer's restorer
// clean up the frames as one clip, with the photos that it has in the loop. If that is a restorer of carried photos
// (gsf_restorer_info.needs_carried), a frame is exposed as the photos' camera would have (gsf_fix_desc.auto_exposure) and, with
// fewer than six photos, changes only as far as the splats are opaque. color, confidence: `count` f32 images of that size with
// 3 and 1 channels; the splats stay as they are. More fixers than one are copies, trained on the same photos with other seeds,
// which err differently: frames become the mean of what the restorer makes of each copy's renders, at any opacity, and, the
// more it makes these differ, that of the renders themselves. They may share a restorer, which one fixer keeps begun until it
// trains or is destroyed, and several do not. GSF_ERROR_INVALID_ARGUMENT without fixers, without a restorer or within a round.
GSF_API GSF_NODISCARD gsf_result gsf_splat_restore_views(gsf_context* ctx, gsf_fixer* const* fixers, size_t fixer_count,
                                                         const gsf_camera* cameras, size_t count, gsf_image* color,
                                                         gsf_image* confidence);
// Checkpoint between steps. A fixer made from the same desc, views and initial splats continues from it bit-identically.
GSF_API void gsf_splat_format_fixer(gsf_context* ctx, const gsf_fixer* fixer, gsf_buffer* chunks);
GSF_API GSF_NODISCARD gsf_result gsf_splat_parse_fixer(gsf_context* ctx, gsf_fixer* fixer, const char* name,
                                                       const void* chunks, size_t size);

// ---- from photos to splats -----------------------------------------------------
/* The choices of the program `gsfix fix`, based on measurements (bench/TRIED.md) with scenes of 3 to 50 photos. A host
   that makes the same calls gets bit-identical splats; every value may be changed in between.
       gsf_splat_load_scene              cameras and points
       gsf_splat_load_train_views        photos
       gsf_splat_make_initial_splats     points -> splats to begin with
       gsf_splat_resolve_few_view_desc   settings of the loop and of the trainer
       gsf_splat_make_fixer              or gsf_splat_make_trainer with the desc's `train`, to train without repair; once
                                         more, with desc.copies, to join fixers that were trained with several seeds
   `views` are indices into scene->views; NULL = all of them in their order (view_count is then scene->view_count). */

// Decodes the photos of these views, unless already present, and lists them for a trainer or fixer. *out is freed with
// gsf_free; the scene keeps ownership of the images.
GSF_API GSF_NODISCARD gsf_result gsf_splat_load_train_views(gsf_context* ctx, gsf_scene* scene, const uint32_t* views,
                                                            size_t view_count, gsf_train_view** out);

typedef enum gsf_initial_kind { // which points become splats
    GSF_INITIAL_AUTO = 0,  // RANDOM for a scene without points, BOTH for a single view, else DENSE
    GSF_INITIAL_BOTH,      // points of the scene that a view sees, by track or by ray
    GSF_INITIAL_TRACKS,    // points whose track contains a view: the start used in the papers; so few that it is better to
                           // densify for 2/3 of the iterations (gsf_train_desc.densify_until), as `gsfix fix` does
    GSF_INITIAL_RAYS,      // points that a ray from a view reaches
    GSF_INITIAL_ALL,       // all points of the scene
    GSF_INITIAL_DENSE,     // BOTH, plus points of multi-view stereo between the views
    GSF_INITIAL_RANDOM,    // drawn evenly from the volumes that the views see, coloured by their photos
} gsf_initial_kind;

typedef struct gsf_initial_desc {
    gsf_initial_kind kind;
    uint64_t seed;
    int32_t sh_degree;              // of the splats; 0 = 3, negative = 0
    int32_t random_points;          // RANDOM: how many; 0 = 20000
    gsf_visibility_desc visibility; // BOTH, TRACKS, RAYS, DENSE; its method follows from the kind
    gsf_dense_desc dense;           // DENSE; max_points 0 = 40000, its seed is the one above, skip_sparse is on
} gsf_initial_desc;

typedef struct gsf_initial_stats {
    gsf_initial_desc used;           // the desc with its defaults filled in; its kind is never AUTO
    size_t scene_points, new_points; // from the scene; by stereo or at random
    gsf_visibility_stats visibility; // zero if the filter was not used
    gsf_dense_stats dense;           // zero if stereo was not used
} gsf_initial_stats;

// DENSE and RANDOM need the views' images. GSF_ERROR_DEGENERATE if no point is left. desc and stats may be NULL.
GSF_API GSF_NODISCARD gsf_result gsf_splat_make_initial_splats(gsf_context* ctx, const gsf_scene* scene,
                                                               const uint32_t* views, size_t view_count,
                                                               const gsf_initial_desc* desc, gsf_splats* out,
                                                               gsf_initial_stats* stats);

typedef enum gsf_quality { // savings and costs: bench/QUALITY.md
    GSF_QUALITY_BALANCED = 0, // windows whose render agrees with the photos to 45 dB are not restored
    GSF_QUALITY_EXACT,        // no approximations
    GSF_QUALITY_FAST,         // lazy_adam; windows are skipped from 36 dB on, frames restored at 320 x 240 pixels
} gsf_quality;

// The loop's settings for few photos: 1200 iterations, regularisers (train.depth_smoothness; dropout and opacity_decay, which
// are twice as strong for up to 3 photos as for 6 or more, in between in inverse proportion to view_count), train.lr_scales
// for a dense start (its default for up to 6 photos, twice that for 9 or more, in between linear), the settings of `quality`,
// and from the scene (NULL = none) the near plane for all its cameras and the points that determine the axes of the path,
// which are borrowed.
GSF_API gsf_fix_desc gsf_splat_resolve_few_view_desc(const gsf_scene* scene, size_t view_count, gsf_quality quality);

// Near plane for renders of a scene with these cameras, `stride` bytes apart: 0.01 times their extent, at most 0.2. Use
// the same near plane for training and rendering.
GSF_API float gsf_splat_measure_near_plane(const gsf_camera* cameras, size_t stride, size_t count);

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
#if !defined(GSF_SPLAT_IMPLEMENTED) || defined(GSF__ISA)
#define GSF_SPLAT_IMPLEMENTED

// With GSF__ISA defined, the header is including itself to compile one of its GSF__KERNELS_... parts for an instruction
// set: see >>lanes in gsfixer.h.
#ifndef GSF__ISA

#include "gsfixer.h" // adds internals and implementation if it was first included without the implementation macro
#include "gsfixer_traj.h"


#ifdef GSF_USE_ZSTD
#include <zstd.h>
#endif

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

// Checks the canaries of a caller's desc. A macro because the three desc types share only the names of these members.
#define GSF__CHECK_CANARIES(ctx, name, desc)                                                                          \
    do {                                                                                                              \
        if ((desc)->_start_canary != 0 || (desc)->_end_canary != 0)                                                   \
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s desc: was not zeroed (its canaries are not)", name); \
    } while (0)

// Resolves a desc field for which zero is a legal value: zero selects the default, a negative value means zero.
static float gsf__or_zero(float value, float fallback) {
    if (value == 0.0f) return fallback;
    return value < 0.0f ? 0.0f : value;
}

typedef struct gsf__field { const char* name; double value, low, high; } gsf__field; // of a desc, with its legal range

static gsf_result gsf__check_fields(gsf_context* ctx, const char* desc, const gsf__field* fields, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (!(fields[i].value >= fields[i].low && fields[i].value <= fields[i].high))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: %s is %g, allowed %g to %g", desc, fields[i].name,
                            fields[i].value, fields[i].low, fields[i].high);
    return GSF_OK;
}

GSF_API int32_t gsf_splat_count_sh(int32_t sh_degree) { return (sh_degree + 1) * (sh_degree + 1); }

GSF_API gsf_result gsf_splat_make(gsf_context* ctx, size_t count, int32_t sh_degree, gsf_splats* out) {
    memset(out, 0, sizeof *out);
    if (sh_degree < 0 || sh_degree > 3)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "splats: SH degree %d is not 0..3", (int)sh_degree);
    const size_t sh_floats = 3 * (size_t)gsf_splat_count_sh(sh_degree);
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

typedef struct gsf__column { char* data; size_t row; } gsf__column; // an array with `row` bytes per splat

enum { GSF__SPLAT_COLUMNS = 6 };

static void gsf__splat_columns(const gsf_splats* splats, gsf__column out[GSF__SPLAT_COLUMNS]) { // ids last, may be NULL
    const gsf__column columns[GSF__SPLAT_COLUMNS] = {
        {(char*)splats->means, 12}, {(char*)splats->log_scales, 12}, {(char*)splats->quats, 16},
        {(char*)splats->opacity_logits, 4}, {(char*)splats->sh, 12 * (size_t)gsf_splat_count_sh(splats->sh_degree)},
        {(char*)splats->ids, 4}};
    memcpy(out, columns, sizeof columns);
}

// ---- >>order -------------------------------------------------------------------

// Sorts n keys by their upper 32 bits. The sort is stable and the lower 32 bits must ascend on input, so ties end up
// ordered by the lower bits. Returns whichever of the two arrays holds the result.
static uint64_t* gsf__sort_keys(uint64_t* keys, uint64_t* spare, size_t n) {
    enum { SMALL = 48 };
    if (n <= SMALL) {
        for (size_t i = 1; i < n; i++) {
            const uint64_t key = keys[i];
            size_t at = i;
            for (; at > 0 && keys[at - 1] > key; at--) keys[at] = keys[at - 1];
            keys[at] = key;
        }
        return keys;
    }
    uint32_t counts[4][256];
    memset(counts, 0, sizeof counts);
    for (size_t i = 0; i < n; i++)
        for (int pass = 0; pass < 4; pass++) counts[pass][keys[i] >> (32 + 8 * pass) & 255u]++;
    for (int pass = 0; pass < 4; pass++) {
        const int shift = 32 + 8 * pass;
        // All keys share this byte; common for the high byte of depths.
        if (counts[pass][keys[0] >> shift & 255u] == n) continue;
        uint32_t sum = 0;
        for (int b = 0; b < 256; b++) {
            const uint32_t count = counts[pass][b];
            counts[pass][b] = sum;
            sum += count;
        }
        for (size_t i = 0; i < n; i++) spare[counts[pass][keys[i] >> shift & 255u]++] = keys[i];
        uint64_t* swap = keys;
        keys = spare;
        spare = swap;
    }
    return keys;
}

// Spreads the 10 bits of v to every third bit of the result.
static uint64_t gsf__spread_bits(uint64_t v) {
    v = (v | v << 16) & 0x030000ff;
    v = (v | v << 8) & 0x0300f00f;
    v = (v | v << 4) & 0x030c30c3;
    return (v | v << 2) & 0x09249249;
}

// Sorts the means in Morton order. The keys are (code << 32 | index); the grid has 1024 cells along each axis of a box
// that extends three standard deviations either side of the average position. Points outside are clamped to the box.
// keys, spare: room for `count` keys each; returns whichever holds the result.
static uint64_t* gsf__morton_order(const float* means, size_t count, uint64_t* keys, uint64_t* spare) {
    double low[3], scale[3];
    for (size_t c = 0; c < 3; c++) {
        double sum = 0.0, sum2 = 0.0, n = 0.0;
        for (size_t i = 0; i < count; i++) {
            const double x = (double)means[3 * i + c];
            if (!(fabs(x) <= 1e30)) continue;
            sum += x;
            sum2 += x * x;
            n += 1.0;
        }
        const double mean = n > 0.0 ? sum / n : 0.0, variance = n > 0.0 ? sum2 / n - mean * mean : 0.0;
        const double reach = variance > 0.0 ? 3.0 * sqrt(variance) : 0.0;
        low[c] = mean - reach;
        scale[c] = reach > 0.0 ? 512.0 / reach : 0.0;
    }
    for (size_t i = 0; i < count; i++) {
        uint64_t code = 0;
        for (size_t c = 0; c < 3; c++) {
            const double cell = ((double)means[3 * i + c] - low[c]) * scale[c];
            code |= gsf__spread_bits(cell > 0.0 ? (cell < 1023.0 ? (uint64_t)cell : 1023) : 0) << c; // NaN: 0
        }
        keys[i] = code << 32 | i;
    }
    return gsf__sort_keys(keys, spare, count);
}

// Permutes rows: row i becomes the row whose index is in the low 32 bits of order[i]. spare: room for all rows.
static void gsf__reorder(void* rows, size_t row_size, const uint64_t* order, size_t count, void* spare) {
    for (size_t i = 0; i < count; i++)
        memcpy((char*)spare + i * row_size, (const char*)rows + (size_t)(uint32_t)order[i] * row_size, row_size);
    memcpy(rows, spare, count * row_size);
}

GSF_API gsf_result gsf_splat_sort(gsf_context* ctx, gsf_splats* splats) {
    const size_t count = splats->count;
    if (count > UINT32_MAX) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "sort: %zu splats are too many", count);
    gsf__column columns[GSF__SPLAT_COLUMNS];
    size_t widest = 0;
    gsf__splat_columns(splats, columns);
    for (int k = 0; k < GSF__SPLAT_COLUMNS; k++)
        if (columns[k].row > widest) widest = columns[k].row;
    gsf__arena arena = {ctx, NULL, 0};
    uint64_t* keys = (uint64_t*)gsf__arena_alloc(&arena, count, 2 * sizeof(uint64_t));
    void* spare = gsf__arena_alloc(&arena, count, widest);
    const gsf_result result = arena.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    if (result == GSF_OK && count) {
        const uint64_t* order = gsf__morton_order(splats->means, count, keys, keys + count);
        for (int k = 0; k < GSF__SPLAT_COLUMNS; k++)
            if (columns[k].data) gsf__reorder(columns[k].data, columns[k].row, order, count, spare);
    }
    gsf__arena_free(&arena);
    return result;
}

// ---- >>ply ---------------------------------------------------------------------

/* A splat file:  "ply" | format line | "element vertex N" | property lines | "end_header" | N rows
   Columns are found by name, so they may come in any order and unknown ones are ignored. Elements before the vertices
   are skipped; elements after them are never read. f_rest is channel-major in the file (all of red, then green, then
   blue), while gsf_splats.sh is coefficient-major. */

enum { // slots of the columns that a reader can use
    GSF__PLY_X = 0,
    GSF__PLY_DC = 3,
    GSF__PLY_OPACITY = 6,
    GSF__PLY_SCALE = 7,
    GSF__PLY_ROT = 10,
    GSF__PLY_REST = 14,
    GSF__PLY_REST_MAX = 45,
    GSF__PLY_RED = GSF__PLY_REST + GSF__PLY_REST_MAX,
    GSF__PLY_SLOTS = GSF__PLY_RED + 3
};

typedef enum gsf__ply_type {
    GSF__PLY_I8, GSF__PLY_U8, GSF__PLY_I16, GSF__PLY_U16, GSF__PLY_I32, GSF__PLY_U32, GSF__PLY_F32, GSF__PLY_F64,
    GSF__PLY_ABSENT
} gsf__ply_type;

typedef enum gsf__ply_format { GSF__PLY_ASCII, GSF__PLY_LITTLE, GSF__PLY_BIG } gsf__ply_format;

typedef struct gsf__ply_target { // destination of a column's values
    int slot;
    float* first;
    size_t stride; // floats
    size_t offset; // of the column within a row
} gsf__ply_target;

typedef struct gsf__ply { // a validated header; in binary files `count` rows of `row_bytes` fit into the data
    const char* name; // for error messages
    const unsigned char* data;
    size_t size;
    gsf__ply_format format;
    size_t body;      // byte offset of the first vertex row (ASCII: of its text)
    size_t count;     // number of vertices
    size_t columns;   // number of properties per vertex
    size_t row_bytes; // ASCII: of a row of doubles, see gsf__ply_parse_text
    gsf__ply_type type[GSF__PLY_SLOTS];
    size_t offset[GSF__PLY_SLOTS];         // byte offset within the row
    gsf__ply_target targets[GSF__PLY_RED]; // all columns of a splat except x y z
    size_t target_count;
    int all_f32;                           // every target column is little-endian float32, as in nearly all files
    float background[3];                   // of the toolkit's own comment; 0 without it
} gsf__ply;

static int gsf__is_blank(unsigned char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\n'; }

// Finds the next word in [*at, end) and moves *at past it. Returns its length, 0 at the end of the text.
static size_t gsf__next_word(const char** at, const char* end, const char** word) {
    const char* p = *at;
    while (p < end && gsf__is_blank((unsigned char)*p)) p++;
    *word = p;
    while (p < end && !gsf__is_blank((unsigned char)*p)) p++;
    *at = p;
    return (size_t)(p - *word);
}

static int gsf__word_is(const char* word, size_t length, const char* text) {
    return strlen(text) == length && memcmp(word, text, length) == 0;
}

// Parses a word of decimal digits only. Returns 0 on any other character and on overflow.
static int gsf__word_u64(const char* word, size_t length, uint64_t* out) {
    uint64_t value = 0;
    if (length == 0) return 0;
    for (size_t i = 0; i < length; i++) {
        const unsigned digit = (unsigned)(unsigned char)word[i] - '0';
        if (digit > 9 || value > (UINT64_MAX - digit) / 10) return 0;
        value = value * 10 + digit;
    }
    *out = value;
    return 1;
}

static int gsf__word_is_nan_or_inf(const char* word, size_t length, double* out) {
    char lower[10];
    if (length && (*word == '-' || *word == '+')) word++, length--;
    if (length < 3 || length >= sizeof lower) return 0;
    for (size_t i = 0; i < length; i++) lower[i] = (char)(word[i] >= 'A' && word[i] <= 'Z' ? word[i] + 32 : word[i]);
    if (gsf__word_is(lower, length, "nan")) *out = (double)NAN;
    else if (gsf__word_is(lower, length, "inf") || gsf__word_is(lower, length, "infinity")) *out = (double)INFINITY;
    else return 0;
    return 1;
}

// Parses a decimal number that fills the whole word. Also accepts nan and inf (ignoring their sign), which the caller
// must reject. Returns 0 when malformed.
static int gsf__word_double(const char* word, size_t length, double* out) {
    const size_t used = gsf__scan_double(word, length, out);
    return used ? used == length : gsf__word_is_nan_or_inf(word, length, out);
}

static gsf__ply_type gsf__ply_type_of(const char* word, size_t length) {
    static const char* const names[8][2] = {{"char", "int8"},  {"uchar", "uint8"}, {"short", "int16"},
                                            {"ushort", "uint16"}, {"int", "int32"}, {"uint", "uint32"},
                                            {"float", "float32"}, {"double", "float64"}};
    for (int i = 0; i < 8; i++)
        if (gsf__word_is(word, length, names[i][0]) || gsf__word_is(word, length, names[i][1])) return (gsf__ply_type)i;
    return GSF__PLY_ABSENT;
}

static size_t gsf__ply_type_size(gsf__ply_type type) {
    static const unsigned char sizes[9] = {1, 1, 2, 2, 4, 4, 4, 8, 0};
    return sizes[type];
}

// Returns the slot of a column name, GSF__PLY_SLOTS for an unused column, -1 for an f_rest beyond SH degree 3.
static int gsf__ply_slot(const char* word, size_t length) {
    static const char* const names[GSF__PLY_REST] = {"x",      "y",       "z",       "f_dc_0",  "f_dc_1",
                                                     "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
                                                     "rot_0",  "rot_1",   "rot_2",   "rot_3"};
    static const char* const colors[3] = {"red", "green", "blue"};
    for (int i = 0; i < GSF__PLY_REST; i++)
        if (gsf__word_is(word, length, names[i])) return i;
    for (int i = 0; i < 3; i++)
        if (gsf__word_is(word, length, colors[i])) return GSF__PLY_RED + i;
    uint64_t index;
    if (length > 7 && memcmp(word, "f_rest_", 7) == 0 && gsf__word_u64(word + 7, length - 7, &index))
        return index < GSF__PLY_REST_MAX ? GSF__PLY_REST + (int)index : -1;
    return GSF__PLY_SLOTS;
}

typedef struct gsf__ply_element { // the element whose properties are being read
    int seen, is_vertex, has_list;
    uint64_t rows;
    size_t columns, row_bytes;
} gsf__ply_element;

static gsf_result gsf__ply_property(gsf_context* ctx, gsf__ply* ply, gsf__ply_element* element, size_t line,
                                    const char* at, const char* end) {
    const char *type_word, *name_word;
    const size_t type_size = gsf__next_word(&at, end, &type_word);
    if (!element->seen)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: property before any element", ply->name, line);
    if (gsf__word_is(type_word, type_size, "list")) {
        if (element->is_vertex)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: list property inside vertex", ply->name, line);
        element->has_list = 1;
        return GSF_OK;
    }
    const gsf__ply_type type = gsf__ply_type_of(type_word, type_size);
    const size_t name_size = gsf__next_word(&at, end, &name_word);
    if (type == GSF__PLY_ABSENT || name_size == 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: expected \"property TYPE NAME\", got type \"%.*s\"", ply->name,
                        line, (int)(type_size < 40 ? type_size : 40), type_word);
    if (element->is_vertex) {
        const int slot = gsf__ply_slot(name_word, name_size);
        if (slot < 0)
            return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: f_rest beyond SH degree 3 (0..44)", ply->name, line);
        if (slot < GSF__PLY_SLOTS) {
            if (ply->type[slot] != GSF__PLY_ABSENT)
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: column \"%.*s\" occurs twice", ply->name, line,
                                (int)(name_size < 40 ? name_size : 40), name_word);
            ply->type[slot] = type;
            ply->offset[slot] = element->row_bytes;
        }
    }
    element->columns++;
    element->row_bytes += ply->format == GSF__PLY_ASCII ? sizeof(double) : gsf__ply_type_size(type);
    return GSF_OK;
}

// Called after the last property of `element`. Adds the size of elements that precede the vertices to *before, in bytes
// (ASCII: words).
static gsf_result gsf__ply_finish_element(gsf_context* ctx, gsf__ply* ply, const gsf__ply_element* element,
                                          int has_vertex, size_t* before) {
    if (element->is_vertex) {
        ply->columns = element->columns;
        ply->row_bytes = element->row_bytes;
    }
    if (!element->seen || has_vertex) return GSF_OK;
    if (element->has_list && element->rows)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: an element with lists precedes the vertices", ply->name);
    const size_t unit = ply->format == GSF__PLY_ASCII ? element->columns : element->row_bytes;
    size_t skip;
    if (element->rows > SIZE_MAX || !gsf__mul_size((size_t)element->rows, unit, &skip) || skip > ply->size ||
        *before > ply->size - skip)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: the elements before the vertices exceed the file", ply->name);
    *before += skip;
    return GSF_OK;
}

static gsf_result gsf__ply_read_format(gsf_context* ctx, gsf__ply* ply, size_t line, const char* at, const char* end) {
    static const char* const names[3] = {"ascii", "binary_little_endian", "binary_big_endian"};
    const char* word;
    const size_t length = gsf__next_word(&at, end, &word);
    for (int i = 0; i < 3; i++)
        if (gsf__word_is(word, length, names[i])) {
            const size_t version = gsf__next_word(&at, end, &word);
            if (!gsf__word_is(word, version, "1.0")) break;
            ply->format = (gsf__ply_format)i;
            return GSF_OK;
        }
    return gsf_fail(ctx, GSF_ERROR_FORMAT,
                    "%s:%zu: expected format ascii, binary_little_endian or binary_big_endian 1.0", ply->name, line);
}

// Moves ply->body past `words` words.
static gsf_result gsf__ply_skip_words(gsf_context* ctx, gsf__ply* ply, size_t words) {
    const char *at = (const char*)ply->data + ply->body, *end = (const char*)ply->data + ply->size, *word;
    for (; words; words--)
        if (gsf__next_word(&at, end, &word) == 0)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file ends before the vertices", ply->name, ply->size);
    ply->body = (size_t)(at - (const char*)ply->data);
    return GSF_OK;
}

// Sets the start of the vertex rows and checks that the rest of the file has room for `rows` of them.
static gsf_result gsf__ply_place_body(gsf_context* ctx, gsf__ply* ply, uint64_t rows, size_t before) {
    if (ply->format == GSF__PLY_ASCII) {
        GSF__TRY(gsf__ply_skip_words(ctx, ply, before));
    } else {
        if (before > ply->size - ply->body)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file ends before the vertices", ply->name, ply->size);
        ply->body += before;
    }
    const size_t left = ply->size - ply->body;
    // In text, a value takes at least a digit and a separator; the last value of the file needs no separator.
    const size_t fit = ply->columns == 0 ? 0
                       : ply->format == GSF__PLY_ASCII ? (left + 1) / (2 * ply->columns) : left / ply->row_bytes;
    if (rows > fit)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %llu vertices announced, the file has room for %zu", ply->name,
                        ply->body, (unsigned long long)rows, fit);
    ply->count = (size_t)rows;
    return GSF_OK;
}

// Takes the toolkit's own comment, "background R G B", and passes over all others.
static void gsf__ply_read_comment(gsf__ply* ply, const char* at, const char* end) {
    const char* word;
    size_t length = gsf__next_word(&at, end, &word);
    double rgb[3];
    if (!gsf__word_is(word, length, "background")) return;
    for (int c = 0; c < 3; c++) {
        length = gsf__next_word(&at, end, &word);
        if (!length || !gsf__word_double(word, length, &rgb[c]) || !(fabs(rgb[c]) <= 1e3)) return;
    }
    if (gsf__next_word(&at, end, &word) == 0)
        for (int c = 0; c < 3; c++) ply->background[c] = (float)rgb[c];
}

static gsf_result gsf__ply_read_header(gsf_context* ctx, const char* name, const void* data, size_t size,
                                       gsf__ply* ply) {
    memset(ply, 0, sizeof *ply);
    ply->name = name;
    ply->data = (const unsigned char*)(data ? data : "");
    ply->size = size;
    for (int i = 0; i < GSF__PLY_SLOTS; i++) ply->type[i] = GSF__PLY_ABSENT;
    const char* text = (const char*)ply->data;
    gsf__ply_element element;
    memset(&element, 0, sizeof element);
    uint64_t vertices = 0;
    size_t before = 0;
    int has_format = 0, has_vertex = 0;
    for (size_t line = 0, number = 0;; number++) {
        const char* stop = line < size ? (const char*)memchr(text + line, '\n', size - line) : NULL;
        if (!stop && number == 0) stop = text + size; // so a short foreign file is "not a PLY file", not truncated
        if (!stop) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: header without end_header", name, line);
        const char *at = text + line, *word;
        const size_t length = gsf__next_word(&at, stop, &word);
        if (number == 0) {
            if (word != text || !gsf__word_is(word, length, "ply") || stop == text + size)
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: not a PLY file (first line \"ply\" expected)", name);
        } else if (gsf__word_is(word, length, "format")) {
            if (has_format || element.seen)
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: format line out of place", name, line);
            GSF__TRY(gsf__ply_read_format(ctx, ply, line, at, stop));
            has_format = 1;
        } else if (gsf__word_is(word, length, "element")) {
            GSF__TRY(gsf__ply_finish_element(ctx, ply, &element, has_vertex, &before));
            memset(&element, 0, sizeof element);
            element.seen = 1;
            size_t n = gsf__next_word(&at, stop, &word);
            element.is_vertex = gsf__word_is(word, n, "vertex");
            n = gsf__next_word(&at, stop, &word);
            if (!gsf__word_u64(word, n, &element.rows))
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: element count \"%.*s\" is not a 64-bit count", name,
                                line, (int)(n < 40 ? n : 40), word);
            if (element.is_vertex && has_vertex)
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: element vertex occurs twice", name, line);
            if (element.is_vertex) vertices = element.rows, has_vertex = 1;
        } else if (gsf__word_is(word, length, "property")) {
            GSF__TRY(gsf__ply_property(ctx, ply, &element, line, at, stop));
        } else if (gsf__word_is(word, length, "end_header")) {
            GSF__TRY(gsf__ply_finish_element(ctx, ply, &element, has_vertex, &before));
            ply->body = (size_t)(stop - text) + 1;
            break;
        } else if (gsf__word_is(word, length, "comment")) {
            gsf__ply_read_comment(ply, at, stop);
        } else if (!gsf__word_is(word, length, "obj_info") && length) {
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: unknown header line \"%.*s\"", name, line,
                            (int)(length < 40 ? length : 40), word);
        }
        line = (size_t)(stop - text) + 1;
    }
    if (!has_format) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: header without a format line", name, ply->body);
    if (!has_vertex) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: header without element vertex", name, ply->body);
    return gsf__ply_place_body(ctx, ply, vertices, before);
}

static double gsf__ply_value(const unsigned char* p, gsf__ply_type type, int big) {
    unsigned char swapped[8];
    const size_t size = gsf__ply_type_size(type);
    if (big) {
        for (size_t i = 0; i < size; i++) swapped[i] = p[size - 1 - i];
        p = swapped;
    }
    const uint64_t bits = gsf__load_le(p, (int)size);
    const uint32_t low = (uint32_t)bits;
    float narrow;
    double wide;
    switch (type) {
        case GSF__PLY_I8: return (double)(low < 0x80u ? (int32_t)low : (int32_t)low - 0x100);
        case GSF__PLY_I16: return (double)(low < 0x8000u ? (int32_t)low : (int32_t)low - 0x10000);
        case GSF__PLY_I32: return low < 0x80000000u ? (double)low : (double)low - 4294967296.0;
        case GSF__PLY_U8:
        case GSF__PLY_U16:
        case GSF__PLY_U32: return (double)low;
        case GSF__PLY_F32: memcpy(&narrow, &low, sizeof narrow); return (double)narrow;
        case GSF__PLY_F64: memcpy(&wide, &bits, sizeof wide); return wide;
        case GSF__PLY_ABSENT: break;
    }
    return 0.0;
}

static const unsigned char* gsf__ply_row(const gsf__ply* ply, size_t i) {
    return ply->data + ply->body + i * ply->row_bytes;
}

static double gsf__ply_cell(const gsf__ply* ply, const unsigned char* row, int slot) {
    double value;
    if (ply->format != GSF__PLY_ASCII)
        return gsf__ply_value(row + ply->offset[slot], ply->type[slot], ply->format == GSF__PLY_BIG);
    memcpy(&value, row + ply->offset[slot], sizeof value);
    return value;
}

static void gsf__ply_position(const void* arg, size_t i, double* out) {
    const gsf__ply* ply = (const gsf__ply*)arg;
    for (int k = 0; k < 3; k++) out[k] = gsf__ply_cell(ply, gsf__ply_row(ply, i), k);
}

// Replaces the text of an ASCII file's rows by *values, which the caller frees even after an error. Binary: *values = NULL.
static gsf_result gsf__ply_parse_text(gsf_context* ctx, gsf__ply* ply, double** values) {
    const char *at = (const char*)ply->data + ply->body, *end = (const char*)ply->data + ply->size, *word;
    const size_t cells = ply->count * ply->columns; // fits: the text has a digit and a separator for each
    *values = NULL;
    if (ply->format != GSF__PLY_ASCII) return GSF_OK;
    *values = (double*)gsf_alloc(ctx, cells, sizeof **values);
    if (!*values) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t c = 0; c < cells; c++) {
        const size_t length = gsf__next_word(&at, end, &word);
        if (length == 0 || !gsf__word_double(word, length, *values + c))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: expected a number, got %s\"%.*s\"", ply->name,
                            (size_t)(word - (const char*)ply->data), length ? "" : "the end of the file ",
                            (int)(length < 40 ? length : 40), word);
    }
    ply->data = (const unsigned char*)*values;
    ply->body = 0;
    return GSF_OK;
}

static int gsf__compare_doubles(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return (x > y) - (x < y);
}

enum { GSF__ORIGIN_SAMPLES = 1024 };

// Chooses an origin: zero, or the rounded centre of the positions where float32 would lose precision (centre farther
// than 1e5 from zero, or than 1000 times the extent). Centre and extent are the median and the 5..95 % range of at most
// 1024 evenly spaced samples, so that outliers do not move them. axis: n samples of x, then of y, then of z; sorted in
// place.
static void gsf__choose_origin(double* axis, size_t n, double origin[3]) {
    double centre[3], extent = 0.0, distance = 0.0;
    memset(origin, 0, 3 * sizeof(double));
    if (n == 0) return;
    for (int k = 0; k < 3; k++) {
        double* v = axis + (size_t)k * n;
        qsort(v, n, sizeof(double), gsf__compare_doubles);
        centre[k] = v[n / 2];
        extent = fmax(extent, v[n - 1 - n / 20] - v[n / 20]);
        distance = fmax(distance, fabs(centre[k]));
    }
    if (distance > 1e5 || (extent > 0.0 && distance > 1000.0 * extent))
        for (int k = 0; k < 3; k++) origin[k] = floor(centre[k] + 0.5);
}

// Chooses the origin of `count` positions; position_fn(arg, i, xyz) returns position i.
static gsf_result gsf__sample_origin(gsf_context* ctx, size_t count, void (*position_fn)(const void*, size_t, double*),
                                     const void* arg, double origin[3]) {
    const size_t stride = count / GSF__ORIGIN_SAMPLES + 1;
    double* axis = (double*)gsf_alloc(ctx, count / stride + 1, 3 * sizeof(double));
    if (!axis) return GSF_ERROR_OUT_OF_MEMORY;
    size_t n = 0;
    for (size_t k = 0; k < 3; k++)
        for (size_t i = 0; i < count; i += stride) {
            double p[3];
            position_fn(arg, i, p);
            // Skips NaN, infinity and garbage: no real coordinate is beyond 1e12.
            if (fabs(p[0]) < 1e12 && fabs(p[1]) < 1e12 && fabs(p[2]) < 1e12) axis[n++] = p[k];
        }
    gsf__choose_origin(axis, n / 3, origin);
    gsf_free(ctx, axis);
    return GSF_OK;
}

static int gsf__float_is_bad(float f) {
    uint32_t bits;
    memcpy(&bits, &f, sizeof bits);
    return (bits & 0x7f800000u) == 0x7f800000u;
}

// Sets the mean of splat i to position p, relative to the origin. Returns whether it is NaN or infinite.
static int gsf__place_mean(const gsf_splats* s, size_t i, const double p[3]) {
    int bad = 0;
    for (size_t k = 0; k < 3; k++) {
        s->means[3 * i + k] = (float)(p[k] - s->origin[k]);
        bad |= gsf__float_is_bad(s->means[3 * i + k]);
    }
    return bad;
}

typedef struct gsf__decoder { // a file of any format whose rows become splats
    const void* file;
    gsf_splats* splats;
    uint8_t* bad;      // (count) 1 for rows with a NaN or infinite value, which are dropped
    float logits[256]; // of the opacity codes of .splat and .spz
} gsf__decoder;

enum { GSF__CODEC_CHUNK = 4096 }; // rows

static size_t gsf__codec_chunks(size_t count) { return (count + GSF__CODEC_CHUNK - 1) / GSF__CODEC_CHUNK; }

static size_t gsf__codec_end(size_t count, size_t begin) {
    return begin + GSF__CODEC_CHUNK < count ? begin + GSF__CODEC_CHUNK : count;
}

static void gsf__ply_add_target(gsf__ply* ply, int slot, float* first, size_t stride) {
    gsf__ply_target* t = &ply->targets[ply->target_count++];
    t->slot = slot;
    t->first = first;
    t->stride = stride;
    t->offset = ply->offset[slot];
    ply->all_f32 = ply->all_f32 && ply->type[slot] == GSF__PLY_F32;
}

static void gsf__ply_list_targets(gsf__ply* ply, const gsf_splats* s) {
    const int bands = gsf_splat_count_sh(s->sh_degree);
    const size_t sh = 3 * (size_t)bands;
    ply->all_f32 = ply->format == GSF__PLY_LITTLE;
    for (int k = 0; k < 3; k++) gsf__ply_add_target(ply, GSF__PLY_DC + k, s->sh + k, sh);
    gsf__ply_add_target(ply, GSF__PLY_OPACITY, s->opacity_logits, 1);
    for (int k = 0; k < 3; k++) gsf__ply_add_target(ply, GSF__PLY_SCALE + k, s->log_scales + k, 3);
    for (int k = 0; k < 4; k++) gsf__ply_add_target(ply, GSF__PLY_ROT + k, s->quats + k, 4);
    for (int channel = 0, slot = GSF__PLY_REST; channel < 3; channel++)
        for (int k = 1; k < bands; k++) gsf__ply_add_target(ply, slot++, s->sh + 3 * k + channel, sh);
}

// Decodes a row of little-endian float32 columns. Collects NaN and infinity in one bit to avoid a branch per value.
static int gsf__ply_decode_f32(const gsf__ply* ply, size_t i) {
    const unsigned char* row = gsf__ply_row(ply, i);
    uint32_t bad = 0;
    for (size_t t = 0; t < ply->target_count; t++) {
        const gsf__ply_target* target = &ply->targets[t];
        const unsigned char* at = row + target->offset;
        const uint32_t bits =
            (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
        bad |= (bits & 0x7f800000u) + 0x00800000u; // an exponent of all ones carries into the top bit
        memcpy(target->first + i * target->stride, &bits, sizeof bits);
    }
    return (int)(bad >> 31);
}

static int gsf__ply_decode_any(const gsf__ply* ply, size_t i) {
    const unsigned char* row = gsf__ply_row(ply, i);
    int bad = 0;
    for (size_t t = 0; t < ply->target_count; t++) {
        const gsf__ply_target* target = &ply->targets[t];
        const float f = (float)gsf__ply_cell(ply, row, target->slot);
        bad |= gsf__float_is_bad(f);
        target->first[i * target->stride] = f;
    }
    return bad;
}

static void gsf__ply_decode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__decoder* job = (const gsf__decoder*)arg;
    const gsf__ply* ply = (const gsf__ply*)job->file;
    const size_t begin = chunk * GSF__CODEC_CHUNK;
    (void)worker;
    for (size_t i = begin; i < gsf__codec_end(ply->count, begin); i++) {
        double p[3];
        const int bad = ply->all_f32 ? gsf__ply_decode_f32(ply, i) : gsf__ply_decode_any(ply, i);
        gsf__ply_position(ply, i, p);
        job->bad[i] = (uint8_t)(bad | gsf__place_mean(job->splats, i, p));
    }
}

// Removes the bad rows. The ids remain consecutive, since gsf_splat_make has numbered them and they are not moved.
static void gsf__drop_rows(gsf_context* ctx, const char* name, const uint8_t* bad, gsf_splats* s) {
    const size_t sh = 3 * (size_t)gsf_splat_count_sh(s->sh_degree);
    size_t kept = 0;
    for (size_t i = 0; i < s->count; i++) {
        if (bad[i]) continue;
        if (kept != i) {
            memcpy(s->means + 3 * kept, s->means + 3 * i, 3 * sizeof(float));
            memcpy(s->log_scales + 3 * kept, s->log_scales + 3 * i, 3 * sizeof(float));
            memcpy(s->quats + 4 * kept, s->quats + 4 * i, 4 * sizeof(float));
            memcpy(s->sh + sh * kept, s->sh + sh * i, sh * sizeof(float));
            s->opacity_logits[kept] = s->opacity_logits[i];
        }
        kept++;
    }
    if (kept != s->count)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu of %zu splats dropped: a value is NaN, infinite or beyond float32",
                name, s->count - kept, s->count);
    s->count = kept;
}

// Logits of the 256 opacity codes. Codes 0 and 255 cover half a step each and decode to its middle, so that their
// logits are finite.
static void gsf__make_logits(float logits[256]) {
    for (int i = 0; i < 256; i++) {
        const double p = (i == 0 ? 0.25 : i == 255 ? 254.75 : (double)i) / 255.0;
        logits[i] = (float)gsf__log_f64(p / (1.0 - p));
    }
}

// Decodes the rows of a file into *out, which has room for them and is destroyed on error. position_fn(file, i, xyz)
// returns the position of row i; decode_chunk is called with a gsf__decoder.
static gsf_result gsf__decode_splats(gsf_context* ctx, const char* name, const void* file,
                                     void (*position_fn)(const void*, size_t, double*), gsf_chunk_fn decode_chunk,
                                     gsf_splats* out) {
    gsf__decoder job;
    job.file = file;
    job.splats = out;
    job.bad = (uint8_t*)gsf_alloc(ctx, out->count, 1);
    gsf__make_logits(job.logits);
    const gsf_result result =
        job.bad ? gsf__sample_origin(ctx, out->count, position_fn, file, out->origin) : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) {
        gsf__parallel_for(ctx, gsf__codec_chunks(out->count), decode_chunk, &job);
        gsf__drop_rows(ctx, name, job.bad, out);
    } else {
        gsf_splat_destroy(ctx, out);
    }
    gsf_free(ctx, job.bad);
    return result;
}

// Checks that all columns of a splat are present and derives *sh_degree from the number of f_rest columns.
static gsf_result gsf__ply_check_columns(gsf_context* ctx, const gsf__ply* ply, int32_t* sh_degree) {
    static const char* const names[5] = {"x, y, z", "f_dc_0..2", "opacity", "scale_0..2", "rot_0..3"};
    static const unsigned char group[GSF__PLY_REST] = {0, 0, 0, 1, 1, 1, 2, 3, 3, 3, 4, 4, 4, 4};
    for (int i = 0; i < GSF__PLY_REST; i++)
        if (ply->type[i] == GSF__PLY_ABSENT)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: no splats: a column of %s is missing", ply->name, ply->body,
                            names[group[i]]);
    int rest = 0, last = -1;
    for (int i = 0; i < GSF__PLY_REST_MAX; i++)
        if (ply->type[GSF__PLY_REST + i] != GSF__PLY_ABSENT) rest++, last = i;
    *sh_degree = rest == 0 ? 0 : rest == 9 ? 1 : rest == 24 ? 2 : rest == 45 ? 3 : -1;
    if (*sh_degree < 0 || last != rest - 1)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %d f_rest columns, the last f_rest_%d; 0, 9, 24 or 45 expected",
                        ply->name, ply->body, rest, last);
    return GSF_OK;
}

static gsf_result gsf__parse_ply(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_splats* out) {
    gsf__ply ply;
    int32_t degree = 0;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf__ply_read_header(ctx, name, data, size, &ply));
    GSF__TRY(gsf__ply_check_columns(ctx, &ply, &degree));
    if (ply.count > UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %zu splats, ids hold 2^32", name, ply.count);
    double* values;
    gsf_result result = gsf__ply_parse_text(ctx, &ply, &values);
    if (result == GSF_OK) result = gsf_splat_make(ctx, ply.count, degree, out);
    if (result == GSF_OK) {
        memcpy(out->background, ply.background, sizeof out->background);
        gsf__ply_list_targets(&ply, out);
        result = gsf__decode_splats(ctx, name, &ply, gsf__ply_position, gsf__ply_decode_chunk, out);
    }
    gsf_free(ctx, values);
    return result;
}

typedef struct gsf__ply_write_job {
    const gsf_splats* splats;
    unsigned char* rows;
    size_t row_bytes;
    int wide; // write x y z as double
} gsf__ply_write_job;

static unsigned char* gsf__put_f32(unsigned char* p, float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    p[0] = (unsigned char)(bits & 255u);
    p[1] = (unsigned char)(bits >> 8 & 255u);
    p[2] = (unsigned char)(bits >> 16 & 255u);
    p[3] = (unsigned char)(bits >> 24);
    return p + 4;
}

static void gsf__ply_encode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__ply_write_job* job = (const gsf__ply_write_job*)arg;
    const gsf_splats* s = job->splats;
    const size_t bands = (size_t)gsf_splat_count_sh(s->sh_degree);
    const size_t begin = chunk * GSF__CODEC_CHUNK;
    (void)worker;
    for (size_t i = begin; i < gsf__codec_end(s->count, begin); i++) {
        unsigned char* p = job->rows + i * job->row_bytes;
        const float* sh = s->sh + 3 * bands * i;
        for (size_t k = 0; k < 3; k++) {
            const double world = s->origin[k] + (double)s->means[3 * i + k];
            if (!job->wide) p = gsf__put_f32(p, (float)world);
            else gsf__store_f64(p, world), p += 8;
        }
        for (int k = 0; k < 3; k++) p = gsf__put_f32(p, 0.0f); // normals
        for (int k = 0; k < 3; k++) p = gsf__put_f32(p, sh[k]);
        for (size_t channel = 0; channel < 3; channel++)
            for (size_t k = 1; k < bands; k++) p = gsf__put_f32(p, sh[3 * k + channel]);
        p = gsf__put_f32(p, s->opacity_logits[i]);
        for (size_t k = 0; k < 3; k++) p = gsf__put_f32(p, s->log_scales[3 * i + k]);
        for (size_t k = 0; k < 4; k++) p = gsf__put_f32(p, s->quats[4 * i + k]);
    }
}

// Appends room for `count` rows to `out`. Returns where they begin; NULL when out of memory.
static unsigned char* gsf__append_rows(gsf_context* ctx, gsf_buffer* out, size_t count, size_t row_bytes) {
    const size_t before = out->size;
    size_t bytes;
    if (!gsf__mul_size(count, row_bytes, &bytes) || bytes > SIZE_MAX / 2) {
        (void)gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "out of memory: %zu splats", count);
        return NULL;
    }
    if (out->failed ||
        gsf__reserve(ctx, (void**)&out->data, &out->capacity, before, before + bytes + 1, 1) != GSF_OK)
        return NULL;
    out->size += bytes;
    out->data[out->size] = 0;
    return (unsigned char*)out->data + before;
}

static void gsf__splats_sample_position(const void* arg, size_t i, double* out) {
    const gsf_splats* s = (const gsf_splats*)arg;
    for (size_t k = 0; k < 3; k++) out[k] = s->origin[k] + (double)s->means[3 * i + k];
}

static gsf_result gsf__format_ply(gsf_context* ctx, const gsf_splats* splats, gsf_buffer* out) {
    gsf__ply_write_job job;
    double origin[3];
    if (splats->sh_degree < 0 || splats->sh_degree > 3)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "splats: SH degree %d is not 0..3", (int)splats->sh_degree);
    GSF__TRY(gsf__sample_origin(ctx, splats->count, gsf__splats_sample_position, splats, origin));
    const int rest = 3 * (gsf_splat_count_sh(splats->sh_degree) - 1);
    job.splats = splats;
    job.wide = origin[0] != 0.0 || origin[1] != 0.0 || origin[2] != 0.0;
    job.row_bytes = 4 * (size_t)(17 + rest) + (job.wide ? 12 : 0);
    const float* b = splats->background;
    gsf_append_text(ctx, out, "ply\nformat binary_little_endian 1.0\n");
    if (b[0] != 0.0f || b[1] != 0.0f || b[2] != 0.0f)
        gsf_append_text(ctx, out, "comment background %.9g %.9g %.9g\n", (double)b[0], (double)b[1], (double)b[2]);
    gsf_append_text(ctx, out, "element vertex %zu\n", splats->count);
    for (int k = 0; k < 3; k++) gsf_append_text(ctx, out, "property %s %c\n", job.wide ? "double" : "float", "xyz"[k]);
    for (int k = 0; k < 3; k++) gsf_append_text(ctx, out, "property float n%c\n", "xyz"[k]);
    for (int k = 0; k < 3; k++) gsf_append_text(ctx, out, "property float f_dc_%d\n", k);
    for (int k = 0; k < rest; k++) gsf_append_text(ctx, out, "property float f_rest_%d\n", k);
    gsf_append_text(ctx, out, "property float opacity\n");
    for (int k = 0; k < 3; k++) gsf_append_text(ctx, out, "property float scale_%d\n", k);
    for (int k = 0; k < 4; k++) gsf_append_text(ctx, out, "property float rot_%d\n", k);
    gsf_append_text(ctx, out, "end_header\n");
    job.rows = gsf__append_rows(ctx, out, splats->count, job.row_bytes);
    if (!job.rows) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__parallel_for(ctx, gsf__codec_chunks(splats->count), gsf__ply_encode_chunk, &job);
    return GSF_OK;
}

// ---- >>formats -----------------------------------------------------------------

/* Choosing the format by file name, and the compact formats .splat and .spz. These store positions as float32 or 24-bit
   fixed point relative to zero, so origin + mean is rounded; gsf__pack_plan measures what that costs. */

static const float gsf__dc_scale = 0.28209479177387814f; // SH band 0: colour = 0.5 + gsf__dc_scale * coefficient

// The signs that SH coefficients get where axes change theirs: those of their polynomials.
static void gsf__sh_signs(const float axes[3], float signs[16]) {
    static const uint8_t odd[16] = {0, 2, 4, 1, 3, 6, 0, 5, 0, 2, 7, 2, 4, 1, 4, 1}; // bits: in x, y, z
    for (size_t k = 0; k < 16; k++) {
        signs[k] = 1.0f;
        for (int a = 0; a < 3; a++)
            if (odd[k] >> a & 1) signs[k] *= axes[a];
    }
}

static gsf_splat_type gsf__type_of_name(const char* name) {
    static const char* const endings[4] = {".ply", ".splat", ".spz", ".glb"};
    static const gsf_splat_type types[4] = {GSF_SPLAT_PLY, GSF_SPLAT_SPLAT, GSF_SPLAT_SPZ, GSF_SPLAT_GLB};
    const size_t size = strlen(name);
    for (int i = 0; i < 4; i++) {
        const size_t n = strlen(endings[i]);
        size_t k = 0;
        if (size < n) continue;
        while (k < n && (name[size - n + k] == endings[i][k] || name[size - n + k] == endings[i][k] - 'a' + 'A')) k++;
        if (k == n) return types[i];
    }
    return GSF_SPLAT_AUTO;
}

// Rounds to the nearest integer in 0..255, halves up; NaN becomes 0.
static unsigned char gsf__to_u8(float value) {
    return value >= 255.0f ? (unsigned char)255 : value > 0.0f ? (unsigned char)(value + 0.5f) : (unsigned char)0;
}

static float gsf__logistic_u8(float logit) { return 255.0f / (1.0f + gsf__exp_f32(-logit)); }

// Normalises a quaternion. Zero becomes the identity, as in the rasterizer.
static void gsf__unit_quat(const float* q, float out[4]) {
    float largest = 0.0f;
    for (int k = 0; k < 4; k++) largest = fmaxf(largest, fabsf(q[k]));
    const float scale = largest > 1e-15f && largest < 1e15f ? 1.0f : largest; // else the squares over- or underflow
    const float v[4] = {q[0] / scale, q[1] / scale, q[2] / scale, q[3] / scale};
    const float norm = sqrtf(v[1] * v[1] + v[2] * v[2] + v[3] * v[3] + v[0] * v[0]);
    for (int k = 0; k < 4; k++) out[k] = largest > 0.0f ? v[k] / norm : k == 0 ? 1.0f : 0.0f;
}

typedef struct gsf__spz_arrays { // see ".spz (Niantic)" below
    unsigned char *positions, *alphas, *colors, *scales, *rotations, *sh;
} gsf__spz_arrays;

// Splats being written to a format of lower precision.
typedef struct gsf__pack {
    const gsf_splats* splats;
    const char* name;
    size_t count;         // number of splats written
    uint32_t* rows;       // (splats->count) their indices, then unused
    uint8_t* bad;         // (splats->count) 1 where a value is NaN or infinite
    double farthest;      // largest |coordinate| of any position
    double typical;       // median scale
    unsigned char* out;
    int version, fraction;  // .spz
    gsf__spz_arrays arrays; // .spz
} gsf__pack;

static int gsf__any_bad(const float* values, size_t count) {
    int bad = 0;
    for (size_t i = 0; i < count; i++) bad |= gsf__float_is_bad(values[i]);
    return bad;
}

static void gsf__pack_check_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__pack* job = (const gsf__pack*)arg;
    const gsf_splats* s = job->splats;
    const size_t sh = 3 * (size_t)gsf_splat_count_sh(s->sh_degree), begin = chunk * GSF__CODEC_CHUNK;
    (void)worker;
    for (size_t i = begin; i < gsf__codec_end(s->count, begin); i++) {
        int bad = gsf__any_bad(s->log_scales + 3 * i, 3) | gsf__any_bad(s->quats + 4 * i, 4) |
                  gsf__any_bad(s->opacity_logits + i, 1) | gsf__any_bad(s->sh + sh * i, sh);
        for (size_t k = 0; k < 3; k++) bad |= gsf__float_is_bad((float)(s->origin[k] + (double)s->means[3 * i + k]));
        job->bad[i] = (uint8_t)bad;
    }
}

static float gsf__mean_log_scale(const gsf_splats* s, size_t i) {
    return (s->log_scales[3 * i] + s->log_scales[3 * i + 1] + s->log_scales[3 * i + 2]) / 3.0f;
}

static void gsf__pack_free(gsf_context* ctx, gsf__pack* job) {
    gsf_free(ctx, job->rows);
    gsf_free(ctx, job->bad);
}

static gsf_result gsf__pack_plan(gsf_context* ctx, const char* name, const gsf_splats* splats, gsf__pack* job) {
    double samples[1024];
    size_t n = 0;
    memset(job, 0, sizeof *job);
    job->splats = splats;
    job->name = name;
    if (splats->sh_degree < 0 || splats->sh_degree > 3)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: SH degree %d is not 0..3", name, (int)splats->sh_degree);
    if (splats->count > UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %zu splats, more than the format's 2^32", name, splats->count);
    job->bad = (uint8_t*)gsf_alloc(ctx, splats->count, 1);
    job->rows = (uint32_t*)gsf_alloc(ctx, splats->count, sizeof *job->rows);
    if (!job->bad || !job->rows) {
        gsf__pack_free(ctx, job);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    gsf__parallel_for(ctx, gsf__codec_chunks(splats->count), gsf__pack_check_chunk, job);
    for (size_t i = 0; i < splats->count; i++)
        if (!job->bad[i]) job->rows[job->count++] = (uint32_t)i;
    if (job->count < splats->count)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu of %zu splats left out: a value is NaN, infinite or beyond float32", name,
                splats->count - job->count, splats->count);
    const size_t stride = job->count / GSF__COUNT(samples) + 1;
    for (size_t row = 0; row < job->count; row++) {
        const size_t i = job->rows[row];
        for (size_t k = 0; k < 3; k++)
            job->farthest = fmax(job->farthest, fabs(splats->origin[k] + (double)splats->means[3 * i + k]));
        if (row % stride == 0) samples[n++] = (double)gsf__mean_log_scale(splats, i);
    }
    qsort(samples, n, sizeof samples[0], gsf__compare_doubles);
    job->typical = n ? gsf__exp_f64(samples[n / 2]) : 1.0;
    return GSF_OK;
}

// Warns when positions are too coarse for the size of the splats. step: distance between adjacent coordinate values.
static void gsf__pack_warn_coarse(gsf_context* ctx, const gsf__pack* job, double step) {
    if (job->count && step > 0.25 * job->typical)
        gsf_log(ctx, GSF_LOG_WARNING,
                "%s: coordinates as large as %.6g come in steps of %.3g here, and the median splat has a scale of %.3g; "
                "write them relative to the origin (local), or a PLY",
                job->name, job->farthest, step, job->typical);
}

/* .splat: no header, only rows of 32 bytes, little-endian:
       position 3 x float32 | scale 3 x float32, linear | red green blue opacity u8 |
       quaternion w x y z u8, 128 + 128 q */

enum { GSF__SPLAT_ROW = 32 };

static float gsf__get_f32(const unsigned char* p) {
    const uint32_t bits = (uint32_t)gsf__load_le(p, 4);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void gsf__splat_position(const void* arg, size_t i, double* out) {
    for (int k = 0; k < 3; k++) out[k] = (double)gsf__get_f32((const unsigned char*)arg + GSF__SPLAT_ROW * i + 4 * k);
}

static void gsf__splat_decode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__decoder* job = (const gsf__decoder*)arg;
    const gsf_splats* s = job->splats;
    const size_t begin = chunk * GSF__CODEC_CHUNK;
    (void)worker;
    for (size_t i = begin; i < gsf__codec_end(s->count, begin); i++) {
        const unsigned char* row = (const unsigned char*)job->file + GSF__SPLAT_ROW * i;
        double p[3];
        gsf__splat_position(job->file, i, p);
        int bad = gsf__place_mean(s, i, p);
        for (size_t k = 0; k < 3; k++) {
            const float scale = gsf__get_f32(row + 12 + 4 * k);
            bad |= gsf__float_is_bad(scale) | (scale < 0.0f);
            s->log_scales[3 * i + k] = gsf__log_f32(fmaxf(scale, FLT_MIN)); // files contain zero scales; log(0) is infinite
            s->sh[3 * i + k] = ((float)row[24 + k] / 255.0f - 0.5f) / gsf__dc_scale;
        }
        s->opacity_logits[i] = job->logits[row[27]];
        for (size_t k = 0; k < 4; k++) s->quats[4 * i + k] = ((float)row[28 + k] - 128.0f) / 128.0f;
        job->bad[i] = (uint8_t)bad;
    }
}

static gsf_result gsf__splat_parse(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_splats* out) {
    if (size % GSF__SPLAT_ROW != 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: truncated .splat: a row has 32 bytes, the last one %zu", name,
                        size - size % GSF__SPLAT_ROW, size % GSF__SPLAT_ROW);
    const size_t count = size / GSF__SPLAT_ROW;
    if (count > UINT32_MAX) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %zu splats, ids hold 2^32", name, count);
    GSF__TRY(gsf_splat_make(ctx, count, 0, out));
    return gsf__decode_splats(ctx, name, data, gsf__splat_position, gsf__splat_decode_chunk, out);
}

static void gsf__splat_encode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__pack* job = (const gsf__pack*)arg;
    const gsf_splats* s = job->splats;
    const size_t sh = 3 * (size_t)gsf_splat_count_sh(s->sh_degree), begin = chunk * GSF__CODEC_CHUNK;
    (void)worker;
    for (size_t row = begin; row < gsf__codec_end(job->count, begin); row++) {
        const size_t i = job->rows[row];
        unsigned char* p = job->out + GSF__SPLAT_ROW * row;
        float q[4];
        for (size_t k = 0; k < 3; k++) p = gsf__put_f32(p, (float)(s->origin[k] + (double)s->means[3 * i + k]));
        for (size_t k = 0; k < 3; k++) p = gsf__put_f32(p, fminf(gsf__exp_f32(s->log_scales[3 * i + k]), FLT_MAX));
        for (size_t k = 0; k < 3; k++) *p++ = gsf__to_u8((0.5f + gsf__dc_scale * s->sh[sh * i + k]) * 255.0f);
        *p++ = gsf__to_u8(gsf__logistic_u8(s->opacity_logits[i]));
        gsf__unit_quat(s->quats + 4 * i, q);
        for (size_t k = 0; k < 4; k++) *p++ = gsf__to_u8(q[k] * 128.0f + 128.0f);
    }
}

static gsf_result gsf__splat_format(gsf_context* ctx, const char* name, const gsf_splats* splats, gsf_buffer* out) {
    gsf__pack job;
    GSF__TRY(gsf__pack_plan(ctx, name, splats, &job));
    gsf__pack_warn_coarse(ctx, &job, job.farthest / 8388608.0); // float32 has a 24-bit significand
    job.out = gsf__append_rows(ctx, out, job.count, GSF__SPLAT_ROW);
    if (job.out) gsf__parallel_for(ctx, gsf__codec_chunks(job.count), gsf__splat_encode_chunk, &job);
    gsf__pack_free(ctx, &job);
    return job.out ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

// Appends `data` (size > 0) as a gzip file; leaves `out` unchanged on error.
static gsf_result gsf__gzip_append(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_buffer* out) {
    // Reproducible bytes: no modification time, unknown operating system.
    static const unsigned char head[10] = {0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255};
    const size_t before = out->size;
    char tail[8];
    gsf_append_bytes(ctx, out, (const char*)head, sizeof head);
    gsf_result result = gsf__deflate(ctx, name, data, size, out);
    gsf__store_le(tail, gsf__crc32(0, data, size), 4);
    gsf__store_le(tail + 4, size & 0xffffffffu, 4);
    gsf_append_bytes(ctx, out, tail, sizeof tail);
    if (result == GSF_OK && out->failed) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result != GSF_OK) out->size = before;
    return result;
}

/* .spz (Niantic): a gzip file of, little-endian,
       magic u32 0x5053474e | version u32 | count u32 | SH degree u8 | fraction bits u8 | flags u8 | reserved u8
       positions   count x 3 x i24, in units of 2^-fraction; version 1: 3 x float16
       opacities   count x u8 of [0,1]
       colours     count x 3 x u8: 127.5 + 255 * 0.15 * coefficient of SH band 0
       scales      count x 3 x u8: 16 * (logarithm + 10)
       rotations   count x 3 x u8: 127.5 + 127.5 * x, y, z of the unit quaternion whose w is not negative;
                   version 3: count x u32: index (x y z w) of the largest component in the top 2 bits, then sign and
                   9 bits of each other component in units of sqrt(1/2) / 511; the largest is positive
       SH          count x (K - 1) x 3 x u8: 128 + 128 * coefficient, rounded to 5 (band 1) or 4 bits when writing
   Version 4 is not in gzip: this head, then from byte 15 on the number of streams u8, the offset of their table u32 and 12
   zeros, then extensions. The table has two u64 per stream, its compressed and its whole size; after it come the streams,
   one for each of the arrays above that is not empty, in their order and compressed with zstd.
   SPZ's axes are right, up, back; ours (and PLY's) are right, down, front. So y and z of positions and quaternions
   change sign, and some SH coefficients. */

enum { GSF__SPZ_HEAD = 16, GSF__SPZ_ANTIALIASED = 1, GSF__SPZ_EXTENDED = 2, GSF__SPZ_FRACTION_MAX = 23 };
enum { GSF__SPZ_HEAD4 = 32, GSF__SPZ_ARRAYS = 6, GSF__SPZ_LEVEL = 12 }; // zstd's level, as in Niantic's encoder

static const float gsf__spz_axes[3] = {1.0f, -1.0f, -1.0f};
static const float gsf__spz_color = 0.15f, gsf__sqrt_half = 0.70710678118654752440f;

typedef struct gsf__spz { // decompressed content of a file
    const char* name;
    int version, fraction, degree, flags; // degree: of the file, 0..4
    size_t count, size;                   // size: bytes of content without extensions
    double unit;                          // 2^-fraction
    gsf__spz_arrays arrays;
} gsf__spz;

static size_t gsf__spz_position_size(int version) { return version == 1 ? 6 : 9; }

static size_t gsf__spz_rotation_size(int version) { return version >= 3 ? 4 : 3; }

static size_t gsf__spz_row(int version, int degree) {
    return gsf__spz_position_size(version) + 1 + 3 + 3 + gsf__spz_rotation_size(version) +
           3 * (size_t)(degree * (degree + 2));
}

static gsf__spz_arrays gsf__spz_place(unsigned char* content, size_t count, int version) {
    gsf__spz_arrays a;
    a.positions = content + GSF__SPZ_HEAD;
    a.alphas = a.positions + count * gsf__spz_position_size(version);
    a.colors = a.alphas + count;
    a.scales = a.colors + 3 * count;
    a.rotations = a.scales + 3 * count;
    a.sh = a.rotations + count * gsf__spz_rotation_size(version);
    return a;
}

static gsf_result gsf__spz_read_head(gsf_context* ctx, const char* name, const unsigned char* p, size_t size,
                                     gsf__spz* spz) {
    memset(spz, 0, sizeof *spz);
    spz->name = name;
    if (size < GSF__SPZ_HEAD || memcmp(p, "NGSP", 4) != 0)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: content byte 0: not an SPZ file (magic NGSP expected)", name);
    const unsigned version = (unsigned)gsf__load_le(p + 4, 4);
    if (version < 1 || version > 4)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: content byte 4: SPZ version %u, expected 1 to 4", name, version);
    spz->version = (int)version;
    spz->count = (size_t)gsf__load_le(p + 8, 4);
    spz->degree = p[12];
    spz->fraction = p[13];
    spz->flags = p[14];
    spz->unit = ldexp(1.0, -spz->fraction);
    if (spz->degree > 4)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: content byte 12: SH degree %d is not 0..4", name, spz->degree);
    if (version > 1 && spz->fraction > 30)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: content byte 13: %d fraction bits, expected at most 30", name,
                        spz->fraction);
    if (!gsf__mul_size(spz->count, gsf__spz_row(spz->version, spz->degree), &spz->size) ||
        spz->size > SIZE_MAX - GSF__SPZ_HEAD)
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: %zu splats exceed the address space", name, spz->count);
    spz->size += GSF__SPZ_HEAD;
    return GSF_OK;
}

#ifdef GSF_USE_ZSTD

enum { GSF__ZSTD_RATIO = 1024 }; // the most that is believed, as in Niantic's reader; arrays of real splats compress far less

static void gsf__spz_array_sizes(size_t count, int version, int degree, size_t sizes[GSF__SPZ_ARRAYS]) { // in bytes
    sizes[0] = count * gsf__spz_position_size(version);
    sizes[1] = count;
    sizes[2] = sizes[3] = 3 * count;
    sizes[4] = count * gsf__spz_rotation_size(version);
    sizes[5] = count * 3 * (size_t)(degree * (degree + 2));
}

// Reads a file of version 4, as gsf__spz_inflate.
static gsf_result gsf__spz_read_streams(gsf_context* ctx, const char* name, const unsigned char* data, size_t size,
                                        gsf__spz* spz, unsigned char** out) {
    size_t sizes[GSF__SPZ_ARRAYS], streams = 0;
    GSF__TRY(gsf__spz_read_head(ctx, name, data, size, spz));
    const size_t table = size >= GSF__SPZ_HEAD4 ? (size_t)gsf__load_le(data + GSF__SPZ_HEAD, 4) : 0;
    gsf__spz_array_sizes(spz->count, spz->version, spz->degree, sizes);
    for (int i = 0; i < GSF__SPZ_ARRAYS; i++) streams += sizes[i] > 0;
    if (spz->version != 4 || table < GSF__SPZ_HEAD4 || table > size || data[15] != streams || size - table < 16 * streams)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:4: not the head and table of SPZ version 4, or truncated", name);
    if (spz->size / GSF__ZSTD_RATIO > size)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:8: %zu splats take %zu bytes, more than the file can hold", name, spz->count,
                        spz->size);
    if (spz->flags & GSF__SPZ_EXTENDED)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu bytes of extensions ignored (one of them can change the axes)", name,
                table - GSF__SPZ_HEAD4);
    unsigned char* content = (unsigned char*)gsf_alloc(ctx, spz->size, 1);
    if (!content) return GSF_ERROR_OUT_OF_MEMORY;
    const unsigned char* entry = data + table;
    size_t from = table + 16 * streams, to = GSF__SPZ_HEAD;
    for (int i = 0; i < GSF__SPZ_ARRAYS; i++) {
        if (sizes[i] == 0) continue;
        const uint64_t packed = gsf__load_le(entry, 8), whole = gsf__load_le(entry + 8, 8);
        const size_t got = packed <= size - from && whole == sizes[i]
                               ? ZSTD_decompress(content + to, sizes[i], data + from, (size_t)packed) : SIZE_MAX;
        if (got != sizes[i]) {
            gsf_free(ctx, content);
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: stream %d of %zu bytes is damaged", name, from, i, sizes[i]);
        }
        entry += 16;
        from += (size_t)packed;
        to += sizes[i];
    }
    spz->arrays = gsf__spz_place(content, spz->count, spz->version);
    *out = content;
    return GSF_OK;
}

// Appends the arrays of `raw` as a file of version 4.
static gsf_result gsf__spz_append_streams(gsf_context* ctx, const char* name, const gsf__pack* job, const gsf_buffer* raw,
                                          gsf_buffer* out) {
    size_t sizes[GSF__SPZ_ARRAYS];
    const size_t before = out->size;
    char head[GSF__SPZ_HEAD4] = {0}, entry[16] = {0};
    const char* from = raw->data + GSF__SPZ_HEAD;
    gsf_result result = GSF_OK;
    gsf__spz_array_sizes(job->count, job->version, job->splats->sh_degree, sizes);
    memcpy(head, raw->data, GSF__SPZ_HEAD);
    for (int i = 0; i < GSF__SPZ_ARRAYS; i++) head[15] = (char)(head[15] + (sizes[i] > 0));
    head[GSF__SPZ_HEAD] = GSF__SPZ_HEAD4;
    gsf_append_bytes(ctx, out, head, sizeof head);
    const size_t table = out->size;
    for (int i = 0; i < head[15]; i++) gsf_append_bytes(ctx, out, entry, sizeof entry);
    for (int i = 0, stream = 0; i < GSF__SPZ_ARRAYS && result == GSF_OK; i++) {
        if (sizes[i] == 0) continue;
        const size_t at = out->size, bound = ZSTD_compressBound(sizes[i]);
        char* to = (char*)gsf__append_rows(ctx, out, bound, 1);
        const size_t packed = to ? ZSTD_compress(to, bound, from, sizes[i], GSF__SPZ_LEVEL) : 0;
        if (!to) result = GSF_ERROR_OUT_OF_MEMORY;
        else if (ZSTD_isError(packed))
            result = gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "%s: %s", name, ZSTD_getErrorName(packed));
        if (result != GSF_OK) break;
        out->size = at + packed;
        gsf__store_le(out->data + table + 16 * (size_t)stream, packed, 8);
        gsf__store_le(out->data + table + 16 * (size_t)stream + 8, sizes[i], 8);
        from += sizes[i];
        stream++;
    }
    if (result == GSF_OK && out->failed) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result != GSF_OK) out->size = before;
    return result;
}

#endif // GSF_USE_ZSTD

// Inflates the content into *out (freed by the caller) and sets the pointers of *spz to its arrays.
static gsf_result gsf__spz_inflate(gsf_context* ctx, const char* name, const unsigned char* data, size_t size,
                                   gsf__spz* spz, unsigned char** out) {
    size_t whole = 0;
    *out = NULL;
#ifdef GSF_USE_ZSTD
    if (size >= 8 && memcmp(data, "NGSP", 4) == 0) return gsf__spz_read_streams(ctx, name, data, size, spz, out);
#else
    if (size >= 8 && memcmp(data, "NGSP", 4) == 0)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:4: SPZ version %u needs zstd (GSF_USE_ZSTD)", name,
                        (unsigned)gsf__load_le(data + 4, 4));
#endif
    GSF__TRY(gsf__gzip_read(ctx, name, data, size, out, &whole));
    gsf_result result = gsf__spz_read_head(ctx, name, *out, whole, spz);
    if (result == GSF_OK && spz->version > 3)
        result = gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: content byte 4: SPZ version %d in gzip", name, spz->version);
    if (result == GSF_OK && (whole < spz->size || (whole > spz->size && !(spz->flags & GSF__SPZ_EXTENDED))))
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: content byte 8: %zu splats take %zu bytes, the content has %zu", name,
                          spz->count, spz->size, whole);
    if (result == GSF_OK) {
        if (spz->flags & GSF__SPZ_EXTENDED)
            gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu bytes of extensions ignored (one of them can change the axes)", name,
                    whole - spz->size);
        spz->arrays = gsf__spz_place(*out, spz->count, spz->version);
    } else {
        gsf_free(ctx, *out);
        *out = NULL;
    }
    return result;
}

static void gsf__spz_position(const void* arg, size_t i, double* out) {
    const gsf__spz* spz = (const gsf__spz*)arg;
    for (size_t k = 0; k < 3; k++) {
        if (spz->version == 1) {
            out[k] = (double)gsf__half_to_float((uint16_t)gsf__load_le(spz->arrays.positions + 6 * i + 2 * k, 2));
        } else {
            const int32_t fixed = (int32_t)gsf__load_le(spz->arrays.positions + 9 * i + 3 * k, 3);
            out[k] = (double)(fixed < 0x800000 ? fixed : fixed - 0x1000000) * spz->unit;
        }
        out[k] *= (double)gsf__spz_axes[k];
    }
}

// p: encoded rotation; q: w x y z in our axes.
static void gsf__spz_decode_rotation(const unsigned char* p, int version, float q[4]) {
    float sum = 0.0f;
    if (version < 3) {
        for (int k = 0; k < 3; k++) {
            q[1 + k] = (float)p[k] / 127.5f - 1.0f;
            sum += q[1 + k] * q[1 + k];
        }
        q[0] = sqrtf(fmaxf(0.0f, 1.0f - sum));
    } else {
        uint32_t word = (uint32_t)gsf__load_le(p, 4);
        const int largest = (int)(word >> 30); // index into x y z w; component c is q[(c + 1) & 3]
        for (int c = 3; c >= 0; c--) {
            if (c == largest) continue;
            const float value = gsf__sqrt_half * (float)(word & 511u) / 511.0f;
            q[(c + 1) & 3] = word & 512u ? -value : value;
            sum += value * value;
            word >>= 10;
        }
        q[(largest + 1) & 3] = sqrtf(fmaxf(0.0f, 1.0f - sum));
    }
    q[2] = -q[2];
    q[3] = -q[3];
}

static void gsf__spz_decode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__decoder* job = (const gsf__decoder*)arg;
    const gsf__spz* spz = (const gsf__spz*)job->file;
    const gsf__spz_arrays* from = &spz->arrays;
    const gsf_splats* s = job->splats;
    const size_t begin = chunk * GSF__CODEC_CHUNK, rotation = gsf__spz_rotation_size(spz->version);
    const size_t bands = (size_t)gsf_splat_count_sh(s->sh_degree), stored = (size_t)(spz->degree * (spz->degree + 2));
    float signs[16];
    (void)worker;
    gsf__sh_signs(gsf__spz_axes, signs);
    for (size_t i = begin; i < gsf__codec_end(s->count, begin); i++) {
        const unsigned char* sh = from->sh + 3 * stored * i;
        double p[3];
        gsf__spz_position(spz, i, p);
        job->bad[i] = (uint8_t)gsf__place_mean(s, i, p);
        for (size_t k = 0; k < 3; k++) {
            s->log_scales[3 * i + k] = (float)from->scales[3 * i + k] / 16.0f - 10.0f;
            s->sh[3 * bands * i + k] = ((float)from->colors[3 * i + k] / 255.0f - 0.5f) / gsf__spz_color;
        }
        for (size_t k = 1; k < bands; k++)
            for (size_t c = 0; c < 3; c++)
                s->sh[3 * (bands * i + k) + c] = signs[k] * ((float)sh[3 * (k - 1) + c] - 128.0f) / 128.0f;
        gsf__spz_decode_rotation(from->rotations + rotation * i, spz->version, s->quats + 4 * i);
        s->opacity_logits[i] = job->logits[from->alphas[i]];
    }
}

static gsf_result gsf__spz_parse(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_splats* out) {
    gsf__spz spz;
    unsigned char* content;
    GSF__TRY(gsf__spz_inflate(ctx, name, (const unsigned char*)data, size, &spz, &content));
    gsf_result result = gsf_splat_make(ctx, spz.count, spz.degree < 3 ? spz.degree : 3, out);
    if (result == GSF_OK) {
        out->antialiased = (spz.flags & GSF__SPZ_ANTIALIASED) != 0;
        result = gsf__decode_splats(ctx, name, &spz, gsf__spz_position, gsf__spz_decode_chunk, out);
    }
    if (result == GSF_OK && spz.degree > 3) gsf_log(ctx, GSF_LOG_WARNING, "%s: SH band 4 ignored", name);
    gsf_free(ctx, content);
    return result;
}

static void gsf__spz_encode_rotation(const float* quat, int version, unsigned char* p) {
    float q[4], v[4]; // v: x y z w in the file's axes
    gsf__unit_quat(quat, q);
    v[0] = q[1];
    v[1] = -q[2];
    v[2] = -q[3];
    v[3] = q[0];
    if (version < 3) {
        for (int k = 0; k < 3; k++) p[k] = gsf__to_u8(v[k] * (v[3] < 0.0f ? -127.5f : 127.5f) + 127.5f);
        return;
    }
    int largest = 0;
    for (int c = 1; c < 4; c++)
        if (fabsf(v[c]) > fabsf(v[largest])) largest = c;
    uint32_t word = (uint32_t)largest;
    for (int c = 0; c < 4; c++) {
        if (c == largest) continue;
        const uint32_t size = (uint32_t)(511.0f * (fabsf(v[c]) / gsf__sqrt_half) + 0.5f);
        word = word << 10 | (uint32_t)((v[c] < 0.0f) != (v[largest] < 0.0f)) << 9 | (size < 511u ? size : 511u);
    }
    gsf__store_le(p, word, 4);
}

// Encodes value as 128 + 128 * value, rounded to the nearest multiple of `bucket`.
static unsigned char gsf__spz_encode_sh(float value, int bucket) {
    const float scaled = value * 128.0f;
    if (scaled >= 127.0f) return 255;
    if (scaled <= -128.0f) return 0;
    const int whole = (int)(scaled < 0.0f ? scaled - 0.5f : scaled + 0.5f) + 128;
    const int rounded = (whole + bucket / 2) / bucket * bucket;
    return (unsigned char)(rounded < 255 ? rounded : 255);
}

static void gsf__spz_encode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__pack* job = (const gsf__pack*)arg;
    const gsf_splats* s = job->splats;
    const size_t bands = (size_t)gsf_splat_count_sh(s->sh_degree), begin = chunk * GSF__CODEC_CHUNK;
    const size_t rotation = gsf__spz_rotation_size(job->version);
    const gsf__spz_arrays* to = &job->arrays;
    const double units = ldexp(1.0, job->fraction);
    float signs[16];
    (void)worker;
    gsf__sh_signs(gsf__spz_axes, signs);
    for (size_t row = begin; row < gsf__codec_end(job->count, begin); row++) {
        const size_t i = job->rows[row];
        unsigned char* sh = to->sh + 3 * (bands - 1) * row;
        for (size_t k = 0; k < 3; k++) {
            const double p = (s->origin[k] + (double)s->means[3 * i + k]) * units * (double)gsf__spz_axes[k];
            const int32_t fixed = (int32_t)(p < 0.0 ? p - 0.5 : p + 0.5); // gsf__spz_choose_fraction keeps it in range
            gsf__store_le(to->positions + 9 * row + 3 * k, (uint32_t)fixed & 0xffffffu, 3);
            to->scales[3 * row + k] = gsf__to_u8((s->log_scales[3 * i + k] + 10.0f) * 16.0f);
            to->colors[3 * row + k] = gsf__to_u8(s->sh[3 * bands * i + k] * (gsf__spz_color * 255.0f) + 127.5f);
        }
        to->alphas[row] = gsf__to_u8(gsf__logistic_u8(s->opacity_logits[i]));
        gsf__spz_encode_rotation(s->quats + 4 * i, job->version, to->rotations + rotation * row);
        for (size_t k = 1; k < bands; k++)
            for (size_t c = 0; c < 3; c++)
                sh[3 * (k - 1) + c] = gsf__spz_encode_sh(signs[k] * s->sh[3 * (bands * i + k) + c], k < 4 ? 8 : 16);
    }
}

// Chooses the fraction bits: 12 as in Niantic's encoder; more where splats are small, so that a step is at most 1/32 of
// the median scale; fewer where positions would not fit into 24 bits otherwise.
static gsf_result gsf__spz_choose_fraction(gsf_context* ctx, gsf__pack* job) {
    const double most = 8388607.0;
    if (job->farthest > most)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED,
                        "%s: a coordinate of %.9g: SPZ holds up to 8388607; write relative to the origin (local), or a PLY",
                        job->name, job->farthest);
    job->fraction = 12;
    while (job->fraction < GSF__SPZ_FRACTION_MAX && ldexp(1.0, -job->fraction) > job->typical / 32.0) job->fraction++;
    while (job->fraction > 0 && ldexp(job->farthest, job->fraction) > most) job->fraction--;
    gsf__pack_warn_coarse(ctx, job, ldexp(1.0, -job->fraction));
    return GSF_OK;
}

// Warns about splats whose largest scale does not fit into 8 bits. Clamping the thinner axes is not visible.
static void gsf__spz_warn_scales(gsf_context* ctx, const gsf__pack* job) {
    const gsf_splats* s = job->splats;
    size_t clamped = 0;
    for (size_t row = 0; row < job->count; row++) {
        const float* v = s->log_scales + 3 * job->rows[row];
        const float largest = fmaxf(fmaxf(v[0], v[1]), v[2]);
        clamped += largest > 6.0f || largest < -10.0f;
    }
    if (clamped)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu of %zu splats are larger than 379 or smaller than 4.5e-5: clamped",
                job->name, clamped, job->count);
}

static gsf_result gsf__spz_format(gsf_context* ctx, const char* name, const gsf_splats* splats, int version,
                                  gsf_buffer* out) {
    const char head[GSF__SPZ_HEAD] = {'N', 'G', 'S', 'P'};
    gsf__pack job;
    gsf_buffer raw;
    memset(&raw, 0, sizeof raw);
    if (version < 2 || version > 4)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: SPZ version %d, expected 2 to 4", name, version);
#ifndef GSF_USE_ZSTD
    if (version == 4) return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: SPZ version 4 needs zstd (GSF_USE_ZSTD)", name);
#endif
    GSF__TRY(gsf__pack_plan(ctx, name, splats, &job));
    job.version = version;
    gsf_result result = gsf__spz_choose_fraction(ctx, &job);
    gsf__spz_warn_scales(ctx, &job);
    if (result == GSF_OK) {
        gsf_append_bytes(ctx, &raw, head, sizeof head);
        job.out = gsf__append_rows(ctx, &raw, job.count, gsf__spz_row(version, splats->sh_degree));
        if (!job.out) result = GSF_ERROR_OUT_OF_MEMORY;
    }
    if (result == GSF_OK) {
        gsf__store_le(raw.data + 4, (uint64_t)version, 4);
        gsf__store_le(raw.data + 8, job.count, 4);
        raw.data[12] = (char)splats->sh_degree;
        raw.data[13] = (char)job.fraction;
        raw.data[14] = splats->antialiased ? GSF__SPZ_ANTIALIASED : 0;
        job.arrays = gsf__spz_place((unsigned char*)raw.data, job.count, version);
        gsf__parallel_for(ctx, gsf__codec_chunks(job.count), gsf__spz_encode_chunk, &job);
#ifdef GSF_USE_ZSTD
        result = version == 4 ? gsf__spz_append_streams(ctx, name, &job, &raw, out)
                              : gsf__gzip_append(ctx, name, raw.data, raw.size, out);
#else
        result = gsf__gzip_append(ctx, name, raw.data, raw.size, out);
#endif
    }
    gsf_destroy_buffer(ctx, &raw);
    gsf__pack_free(ctx, &job);
    return result;
}

/* .glb: binary glTF 2.0 with the extension KHR_gaussian_splatting, as ratified: a header, a chunk of JSON and a chunk of
   arrays, to which the JSON's accessors point. A primitive of points has the attributes POSITION and, with the extension's
   name in front, ROTATION (unit, x y z w), SCALE (not its logarithm), OPACITY (not its logit) and SH_DEGREE_l_COEF_n, whose
   coefficients are those of the PLY. glTF's axes are left, up, forward; so x and y change sign. */

enum {
    GSF__GLB_HEAD = 12,
    GSF__GLB_CHUNK = 8,
    GSF__GLB_DEPTH = 64,  // of nodes in nodes
    GSF__GLB_POSITION = 0,
    GSF__GLB_ROTATION,
    GSF__GLB_SCALE,
    GSF__GLB_OPACITY,
    GSF__GLB_SH,  // indices of columns
    GSF__GLB_COLUMNS = GSF__GLB_SH + 16
};

static const char gsf__glb_extension[] = "KHR_gaussian_splatting";
static const float gsf__glb_axes[3] = {-1.0f, -1.0f, 1.0f};
static const int gsf__glb_sizes[GSF__GLB_SH + 1] = {3, 4, 3, 1, 3};  // components of each column

typedef struct gsf__glb_column {  // an accessor
    const unsigned char* data;
    size_t stride;
    int type, normalized;  // glTF's component type
} gsf__glb_column;

typedef struct gsf__glb_part {  // a primitive, where a node places it
    size_t first, count;        // its splats
    int degree;
    double matrix[16];  // to the world, in glTF's axes: a rotation times `scale`, and a translation
    double scale;
    float quat[4];  // the rotation
    gsf__glb_column columns[GSF__GLB_COLUMNS];
} gsf__glb_part;

typedef struct gsf__glb {
    gsf_context* ctx;
    const char* name;
    gsf_json json;
    const unsigned char* bytes;  // the chunk of arrays
    size_t byte_count;
    gsf__glb_part* parts;
    size_t part_count, part_room, nodes_met;
    size_t count;
    int degree;
    int log_scales, logits;  // files of early writers hold logarithms and logits
    float signs[16];
} gsf__glb;

// `at` may be NULL: the error is then about the whole JSON.
static gsf_result gsf__glb_fail(const gsf__glb* glb, const gsf_json_value* at, const char* what) {
    const size_t offset = GSF__GLB_HEAD + GSF__GLB_CHUNK + (at ? (size_t)at->offset : 0);
    return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:%zu: %s", glb->name, offset, what);
}

static const gsf_json_value* gsf__glb_member(const gsf__glb* glb, const gsf_json_value* object, const char* key) {
    return gsf_find_json_member(&glb->json, object, key);
}

// A member that is an integer in [0, most]; `otherwise` if it is missing. A negative `otherwise` makes it required.
static gsf_result gsf__glb_integer(const gsf__glb* glb, const gsf_json_value* object, const char* key, double most,
                                   double otherwise, size_t* out) {
    const gsf_json_value* value = gsf__glb_member(glb, object, key);
    const double number = value && value->type == GSF_JSON_NUMBER ? value->number : value ? -1.0 : otherwise;
    if (!(number >= 0.0 && number <= most && number == floor(number)))
        return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:%zu: \"%s\" is not an integer in 0..%.0f", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)(value ? value : object)->offset, key, most);
    *out = (size_t)number;
    return GSF_OK;
}

// The element of a top-level array that a member of `object` refers to.
static gsf_result gsf__glb_element(const gsf__glb* glb, const gsf_json_value* object, const char* key, const char* array,
                                   const gsf_json_value** out) {
    const gsf_json_value* list = gsf__glb_member(glb, &glb->json.values[0], array);
    size_t index;
    if (!list || list->type != GSF_JSON_ARRAY || list->count == 0)
        return gsf__glb_fail(glb, object, "refers to a missing array");
    GSF__TRY(gsf__glb_integer(glb, object, key, (double)list->count - 1.0, -1.0, &index));
    *out = gsf_find_json_element(&glb->json, list, index);
    if ((*out)->type != GSF_JSON_OBJECT) return gsf__glb_fail(glb, *out, "not an object");
    return GSF_OK;
}

static size_t gsf__glb_type_size(int type) {
    return type == 5126 ? 4 : type == 5122 || type == 5123 ? 2 : type == 5120 || type == 5121 ? 1 : 0;
}

// Reads the accessor of an attribute with `components` values per row.
static gsf_result gsf__glb_read_column(const gsf__glb* glb, const gsf_json_value* attributes, const char* key, int components,
                                       size_t* count, gsf__glb_column* out) {
    static const char* const kinds[5] = {"", "SCALAR", "", "VEC3", "VEC4"};
    const gsf_json_value *accessor, *view;
    size_t type, rows, offset, first, size, stride, buffer;
    GSF__TRY(gsf__glb_element(glb, attributes, key, "accessors", &accessor));
    const gsf_json_value *kind = gsf__glb_member(glb, accessor, "type"),
                         *normalized = gsf__glb_member(glb, accessor, "normalized");
    GSF__TRY(gsf__glb_integer(glb, accessor, "componentType", 65535.0, -1.0, &type));
    GSF__TRY(gsf__glb_integer(glb, accessor, "count", (double)UINT32_MAX, -1.0, &rows));
    GSF__TRY(gsf__glb_integer(glb, accessor, "byteOffset", (double)UINT32_MAX, 0.0, &offset));
    const size_t width = gsf__glb_type_size((int)type) * (size_t)components;
    if (!kind || kind->type != GSF_JSON_STRING || strcmp(kind->string, kinds[components]) != 0 || width == 0)
        return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:%zu: %s: not a %s of floats, bytes or shorts", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)accessor->offset, key, kinds[components]);
    if (gsf__glb_member(glb, accessor, "sparse") || !gsf__glb_member(glb, accessor, "bufferView"))
        return gsf_fail(glb->ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: %s is a sparse accessor, or is compressed", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)accessor->offset, key);
    GSF__TRY(gsf__glb_element(glb, accessor, "bufferView", "bufferViews", &view));
    GSF__TRY(gsf__glb_integer(glb, view, "buffer", (double)UINT32_MAX, -1.0, &buffer));
    GSF__TRY(gsf__glb_integer(glb, view, "byteOffset", (double)UINT32_MAX, 0.0, &first));
    GSF__TRY(gsf__glb_integer(glb, view, "byteLength", (double)UINT32_MAX, -1.0, &size));
    GSF__TRY(gsf__glb_integer(glb, view, "byteStride", 65535.0, (double)width, &stride));
    if (buffer != 0)
        return gsf_fail(glb->ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: %s is in another file", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)view->offset, key);
    if (first > glb->byte_count || size > glb->byte_count - first || stride < width || offset > size ||
        (rows > 0 && (size - offset < width || (rows - 1) > (size - offset - width) / stride)))
        return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:%zu: %s: %zu rows exceed the file's %zu bytes of arrays", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)accessor->offset, key, rows, glb->byte_count);
    if (*count != SIZE_MAX && rows != *count) return gsf__glb_fail(glb, accessor, "attributes differ in their counts");
    *count = rows;
    out->data = glb->bytes + first + offset;
    out->stride = stride;
    out->type = (int)type;
    out->normalized = normalized && normalized->type == GSF_JSON_TRUE;
    return GSF_OK;
}

static float gsf__glb_value(const gsf__glb_column* column, size_t row, size_t component) {
    const unsigned char* p = column->data + column->stride * row + gsf__glb_type_size(column->type) * component;
    float value, largest;
    switch (column->type) {
        case 5126: return gsf__get_f32(p);
        case 5120: value = (float)(*p < 128 ? *p : *p - 256), largest = 127.0f; break;
        case 5121: value = (float)*p, largest = 255.0f; break;
        case 5122: value = (float)(int16_t)(uint16_t)gsf__load_le(p, 2), largest = 32767.0f; break;
        default: value = (float)gsf__load_le(p, 2), largest = 65535.0f; break;
    }
    return column->normalized ? fmaxf(value / largest, -1.0f) : value;
}

// out = a b, column-major; the last rows are 0 0 0 1.
static void gsf__glb_multiply(const double a[16], const double b[16], double out[16]) {
    double m[16];
    for (int c = 0; c < 4; c++)
        for (int r = 0; r < 4; r++)
            m[4 * c + r] = a[r] * b[4 * c] + a[4 + r] * b[4 * c + 1] + a[8 + r] * b[4 * c + 2] + (c == 3 ? a[12 + r] : 0.0);
    for (int c = 0; c < 4; c++) m[4 * c + 3] = c == 3;
    memcpy(out, m, sizeof m);
}

// Reads `count` numbers; leaves `out` as it is if the member is missing.
static gsf_result gsf__glb_numbers(const gsf__glb* glb, const gsf_json_value* node, const char* key, size_t count,
                                   double* out) {
    const gsf_json_value* list = gsf__glb_member(glb, node, key);
    if (!list) return GSF_OK;
    if (list->type != GSF_JSON_ARRAY || list->count != count)
        return gsf__glb_fail(glb, list, "not a list of as many numbers as needed");
    for (size_t i = 0; i < count; i++) {
        const gsf_json_value* value = gsf_find_json_element(&glb->json, list, i);
        if (value->type != GSF_JSON_NUMBER) return gsf__glb_fail(glb, value, "not a number");
        out[i] = value->number;
    }
    return GSF_OK;
}

// The node's own matrix: `matrix`, or translation x rotation x scale.
static gsf_result gsf__glb_node_matrix(const gsf__glb* glb, const gsf_json_value* node, double out[16]) {
    double t[3] = {0.0, 0.0, 0.0}, q[4] = {0.0, 0.0, 0.0, 1.0}, s[3] = {1.0, 1.0, 1.0};
    memset(out, 0, 16 * sizeof(double));
    GSF__TRY(gsf__glb_numbers(glb, node, "translation", 3, t));
    GSF__TRY(gsf__glb_numbers(glb, node, "rotation", 4, q));
    GSF__TRY(gsf__glb_numbers(glb, node, "scale", 3, s));
    const double x = q[0], y = q[1], z = q[2], w = q[3];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z),     2 * (x * z - w * y),
                         2 * (x * y - w * z),     1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                         2 * (x * z + w * y),     2 * (y * z - w * x),     1 - 2 * (x * x + y * y)};
    for (int c = 0; c < 3; c++) {
        for (int k = 0; k < 3; k++) out[4 * c + k] = s[c] * r[3 * c + k];
        out[12 + c] = t[c];
    }
    out[15] = 1.0;
    return gsf__glb_numbers(glb, node, "matrix", 16, out);
}

// Splits part->matrix into a rotation and one scale.
static gsf_result gsf__glb_split_matrix(const gsf__glb* glb, const gsf_json_value* at, gsf__glb_part* part) {
    const double* m = part->matrix;
    double lengths[3], pose[16], q[4];
    for (int c = 0; c < 3; c++)
        lengths[c] = sqrt(m[4 * c] * m[4 * c] + m[4 * c + 1] * m[4 * c + 1] + m[4 * c + 2] * m[4 * c + 2]);
    const double scale = (lengths[0] + lengths[1] + lengths[2]) / 3.0;
    const double det =
        m[0] * (m[5] * m[10] - m[6] * m[9]) - m[4] * (m[1] * m[10] - m[2] * m[9]) + m[8] * (m[1] * m[6] - m[2] * m[5]);
    int same = scale > 1e-30 && scale < 1e30 && fabs(det / (scale * scale * scale) - 1.0) < 1e-3;
    for (int c = 0; c < 3; c++) same = same && fabs(lengths[c] / scale - 1.0) < 1e-3 && fabs(m[12 + c]) < 1e30;
    if (!same)
        return gsf_fail(glb->ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: a node that stretches or mirrors its splats", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)at->offset);
    for (int i = 0; i < 16; i++) pose[i] = m[i] / scale;
    gsf__quat_of(pose, q);
    for (int k = 0; k < 4; k++) part->quat[k] = (float)q[k];
    part->scale = scale;
    return GSF_OK;
}

static gsf_result gsf__glb_read_primitive(gsf__glb* glb, const gsf_json_value* primitive, const double matrix[16]) {
    const gsf_json_value* extension = gsf__glb_member(glb, gsf__glb_member(glb, primitive, "extensions"), gsf__glb_extension);
    const gsf_json_value* attributes = gsf__glb_member(glb, primitive, "attributes");
    static const char* const names[GSF__GLB_SH] = {"POSITION", "ROTATION", "SCALE", "OPACITY"};
    char key[64];
    size_t count = SIZE_MAX;
    if (!extension) return GSF_OK;
    const gsf_json_value* compressed = gsf__glb_member(glb, extension, "extensions");
    if (compressed && compressed->child)
        return gsf_fail(glb->ctx, GSF_ERROR_UNSUPPORTED, "%s:%zu: %s is not supported", glb->name,
                        GSF__GLB_HEAD + GSF__GLB_CHUNK + (size_t)compressed->offset, glb->json.values[compressed->child].key);
    if (!attributes || attributes->type != GSF_JSON_OBJECT) return gsf__glb_fail(glb, primitive, "splats without attributes");
    GSF__TRY(
        gsf__reserve(glb->ctx, (void**)&glb->parts, &glb->part_room, glb->part_count, glb->part_count + 1, sizeof *glb->parts));
    gsf__glb_part* part = glb->parts + glb->part_count;
    memset(part, 0, sizeof *part);
    memcpy(part->matrix, matrix, sizeof part->matrix);
    GSF__TRY(gsf__glb_split_matrix(glb, primitive, part));
    for (int c = 0; c < GSF__GLB_SH; c++) {
        snprintf(key, sizeof key, "%s%s%s", c ? gsf__glb_extension : "", c ? ":" : "", names[c]);
        GSF__TRY(gsf__glb_read_column(glb, attributes, key, gsf__glb_sizes[c], &count, part->columns + c));
    }
    for (int degree = 0; degree <= 3; degree++) {  // all coefficients of a degree, or none from there on
        for (int k = 0; k < 2 * degree + 1; k++) {
            snprintf(key, sizeof key, "%s:SH_DEGREE_%d_COEF_%d", gsf__glb_extension, degree, k);
            if (degree > 0 && k == 0 && !gsf__glb_member(glb, attributes, key)) goto done;
            GSF__TRY(gsf__glb_read_column(glb, attributes, key, 3, &count, part->columns + GSF__GLB_SH + degree * degree + k));
        }
        part->degree = degree;
    }
done:
    if (count > UINT32_MAX - glb->count || count > glb->byte_count - glb->count) // a bomb, or an instance too many
        return gsf__glb_fail(glb, primitive, "more splats than bytes");
    part->first = glb->count;
    part->count = count;
    glb->count += count;
    if (part->degree > glb->degree) glb->degree = part->degree;
    glb->part_count++;
    return GSF_OK;
}

static gsf_result gsf__glb_read_node(gsf__glb* glb, const gsf_json_value* nodes, size_t index, const double parent[16],
                                     int depth) {
    const gsf_json_value* node = gsf_find_json_element(&glb->json, nodes, index);
    double own[16];
    if (depth > GSF__GLB_DEPTH || glb->nodes_met++ >= nodes->count)
        return gsf__glb_fail(glb, node, "the nodes are no tree, or too deep");
    GSF__TRY(gsf__glb_node_matrix(glb, node, own));
    gsf__glb_multiply(parent, own, own);
    if (gsf__glb_member(glb, node, "mesh")) {
        const gsf_json_value* mesh;
        GSF__TRY(gsf__glb_element(glb, node, "mesh", "meshes", &mesh));
        const gsf_json_value* list = gsf__glb_member(glb, mesh, "primitives");
        for (uint32_t i = list ? list->child : 0; i; i = glb->json.values[i].next)
            GSF__TRY(gsf__glb_read_primitive(glb, glb->json.values + i, own));
    }
    const gsf_json_value* children = gsf__glb_member(glb, node, "children");
    for (uint32_t i = children ? children->child : 0; i; i = glb->json.values[i].next) {
        const gsf_json_value* child = glb->json.values + i;
        if (child->type != GSF_JSON_NUMBER || !(child->number >= 0.0 && child->number < (double)nodes->count))
            return gsf__glb_fail(glb, child, "not the index of a node");
        GSF__TRY(gsf__glb_read_node(glb, nodes, (size_t)child->number, own, depth + 1));
    }
    return GSF_OK;
}

// Finds the splats of the default scene.
static gsf_result gsf__glb_read_nodes(gsf__glb* glb) {
    static const double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    const gsf_json_value* root = glb->json.values;
    const gsf_json_value *nodes = gsf__glb_member(glb, root, "nodes"), *scenes = gsf__glb_member(glb, root, "scenes");
    size_t scene;
    if (!nodes || nodes->type != GSF_JSON_ARRAY || !scenes || scenes->type != GSF_JSON_ARRAY || !scenes->count)
        return gsf__glb_fail(glb, NULL, "has no scene of nodes");
    GSF__TRY(gsf__glb_integer(glb, root, "scene", (double)scenes->count - 1.0, 0.0, &scene));
    const gsf_json_value* roots = gsf__glb_member(glb, gsf_find_json_element(&glb->json, scenes, scene), "nodes");
    for (uint32_t i = roots ? roots->child : 0; i; i = glb->json.values[i].next) {
        const gsf_json_value* value = glb->json.values + i;
        if (value->type != GSF_JSON_NUMBER || !(value->number >= 0.0 && value->number < (double)nodes->count))
            return gsf__glb_fail(glb, value, "not the index of a node");
        GSF__TRY(gsf__glb_read_node(glb, nodes, (size_t)value->number, identity, 0));
    }
    if (!glb->part_count) return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s: has no splats (%s)", glb->name, gsf__glb_extension);
    return GSF_OK;
}

static const gsf__glb_part* gsf__glb_part_of(const gsf__glb* glb, size_t i) {
    const gsf__glb_part* part = glb->parts;
    while (i - part->first >= part->count) part++;
    return part;
}

static void gsf__glb_position(const void* arg, size_t i, double* out) {
    const gsf__glb_part* part = gsf__glb_part_of((const gsf__glb*)arg, i);
    const double* m = part->matrix;
    double p[3];
    for (size_t k = 0; k < 3; k++) p[k] = (double)gsf__glb_value(part->columns + GSF__GLB_POSITION, i - part->first, k);
    for (size_t k = 0; k < 3; k++)
        out[k] = (double)gsf__glb_axes[k] * (m[k] * p[0] + m[4 + k] * p[1] + m[8 + k] * p[2] + m[12 + k]);
}

static void gsf__glb_decode_row(const gsf__glb* glb, const gsf__glb_part* part, size_t i, gsf__decoder* job) {
    const gsf_splats* s = job->splats;
    const gsf__glb_column* columns = part->columns;
    const size_t row = i - part->first, bands = (size_t)gsf_splat_count_sh(s->sh_degree);
    const size_t stored = (size_t)gsf_splat_count_sh(part->degree);
    double p[3];
    gsf__glb_position(glb, i, p);
    int bad = gsf__place_mean(s, i, p);
    const float opacity = gsf__glb_value(columns + GSF__GLB_OPACITY, row, 0);
    s->opacity_logits[i] = glb->logits       ? opacity
                           : opacity <= 0.0f ? job->logits[0]
                           : opacity >= 1.0f ? job->logits[255]
                                             : gsf__log_f32(opacity / (1.0f - opacity));
    bad |= gsf__float_is_bad(opacity);
    for (size_t k = 0; k < 3; k++) {
        const float scale = gsf__glb_value(columns + GSF__GLB_SCALE, row, k);
        const float value = glb->log_scales ? scale : gsf__log_f32(fmaxf(scale, FLT_MIN));
        s->log_scales[3 * i + k] = value + (part->scale == 1.0 ? 0.0f : gsf__log_f32((float)part->scale));
        bad |= gsf__float_is_bad(scale);
    }
    float q[4];  // x y z w of the file
    for (size_t k = 0; k < 4; k++) q[k] = gsf__glb_value(columns + GSF__GLB_ROTATION, row, k);
    const float* n = part->quat;
    float* quat = s->quats + 4 * i;
    quat[0] = n[0] * q[3] - n[1] * q[0] - n[2] * q[1] - n[3] * q[2];
    quat[1] = n[0] * q[0] + n[1] * q[3] + n[2] * q[2] - n[3] * q[1];
    quat[2] = n[0] * q[1] - n[1] * q[2] + n[2] * q[3] + n[3] * q[0];
    quat[3] = n[0] * q[2] + n[1] * q[1] - n[2] * q[0] + n[3] * q[3];
    for (size_t k = 0; k < 3; k++) quat[1 + k] *= gsf__glb_axes[k];  // half a turn about z, and back
    bad |= gsf__any_bad(quat, 4);
    for (size_t k = 0; k < bands; k++)
        for (size_t c = 0; c < 3; c++) {
            const float value = k < stored ? gsf__glb_value(columns + GSF__GLB_SH + k, row, c) : 0.0f;
            s->sh[3 * (bands * i + k) + c] = glb->signs[k] * value;
            bad |= gsf__float_is_bad(value);
        }
    job->bad[i] = (uint8_t)bad;
}

static void gsf__glb_decode_chunk(void* arg, size_t chunk, int32_t worker) {
    gsf__decoder* job = (gsf__decoder*)arg;
    const gsf__glb* glb = (const gsf__glb*)job->file;
    const size_t begin = chunk * GSF__CODEC_CHUNK;
    (void)worker;
    for (size_t i = begin; i < gsf__codec_end(job->splats->count, begin); i++)
        gsf__glb_decode_row(glb, gsf__glb_part_of(glb, i), i, job);
}

// Early writers stored the PLY's logarithms and logits: a negative scale or an opacity outside 0..1 tells.
static void gsf__glb_find_logs(gsf__glb* glb) {
    for (size_t p = 0; p < glb->part_count; p++) {
        const gsf__glb_part* part = glb->parts + p;
        for (size_t i = 0; i < part->count; i++) {
            const float opacity = gsf__glb_value(part->columns + GSF__GLB_OPACITY, i, 0);
            for (size_t k = 0; k < 3; k++) glb->log_scales |= gsf__glb_value(part->columns + GSF__GLB_SCALE, i, k) < 0.0f;
            glb->logits |= opacity < 0.0f || opacity > 1.0f;
        }
    }
    if (glb->log_scales)
        gsf_log(glb->ctx, GSF_LOG_WARNING,
                "%s: negative scales: taken as logarithms, as written before the format's ratification", glb->name);
    if (glb->logits) gsf_log(glb->ctx, GSF_LOG_WARNING, "%s: opacities outside 0..1: taken as logits", glb->name);
}

// Finds the chunks. *json: that of JSON.
static gsf_result gsf__glb_open(gsf__glb* glb, const unsigned char* data, size_t size, const char** json, size_t* json_size) {
    if (size < GSF__GLB_HEAD + GSF__GLB_CHUNK || memcmp(data, "glTF", 4) != 0)
        return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:0: not a binary glTF file", glb->name);
    if (gsf__load_le(data + 4, 4) != 2)
        return gsf_fail(glb->ctx, GSF_ERROR_UNSUPPORTED, "%s:4: glTF version %u, expected 2", glb->name,
                        (unsigned)gsf__load_le(data + 4, 4));
    if (gsf__load_le(data + 8, 4) > size)
        return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:8: truncated: %u of %zu bytes", glb->name,
                        (unsigned)gsf__load_le(data + 8, 4), size);
    size = (size_t)gsf__load_le(data + 8, 4);
    for (size_t at = GSF__GLB_HEAD, chunk = 0; chunk < 2 && at + GSF__GLB_CHUNK <= size; chunk++) {
        const size_t length = (size_t)gsf__load_le(data + at, 4);
        if (length > size - at - GSF__GLB_CHUNK || memcmp(data + at + 4, chunk ? "BIN" : "JSON", 4) != 0)
            return gsf_fail(glb->ctx, GSF_ERROR_FORMAT, "%s:%zu: not a %s chunk, or truncated", glb->name, at,
                            chunk ? "BIN" : "JSON");
        if (chunk) glb->bytes = data + at + GSF__GLB_CHUNK, glb->byte_count = length;
        else *json = (const char*)data + at + GSF__GLB_CHUNK, *json_size = length;
        at += GSF__GLB_CHUNK + length;
    }
    return GSF_OK;
}

static gsf_result gsf__glb_parse(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_splats* out) {
    gsf__glb glb;
    const char* json = "";
    size_t json_size = 0;
    memset(&glb, 0, sizeof glb);
    glb.ctx = ctx;
    glb.name = name;
    GSF__TRY(gsf__glb_open(&glb, (const unsigned char*)data, size, &json, &json_size));
    GSF__TRY(gsf_parse_json(ctx, name, json, json_size, &glb.json));
    gsf_result result = gsf__glb_read_nodes(&glb);
    if (result == GSF_OK) result = gsf_splat_make(ctx, glb.count, glb.degree, out);
    if (result == GSF_OK) {
        gsf__glb_find_logs(&glb);
        gsf__sh_signs(gsf__glb_axes, glb.signs);
        result = gsf__decode_splats(ctx, name, &glb, gsf__glb_position, gsf__glb_decode_chunk, out);
    }
    gsf_free(ctx, glb.parts);
    gsf_destroy_json(ctx, &glb.json);
    return result;
}

// The arrays of a file in their order, COLOR_0 (RGBA, u16, for viewers without splats) last.
static void gsf__glb_encode_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__pack* job = (const gsf__pack*)arg;
    const gsf_splats* s = job->splats;
    const size_t bands = (size_t)gsf_splat_count_sh(s->sh_degree), begin = chunk * GSF__CODEC_CHUNK, n = job->count;
    unsigned char *positions = job->out, *rotations = positions + 12 * n, *scales = rotations + 16 * n;
    unsigned char *opacities = scales + 12 * n, *sh = opacities + 4 * n, *colors = sh + 12 * bands * n;
    float signs[16];
    (void)worker;
    gsf__sh_signs(gsf__glb_axes, signs);
    for (size_t row = begin; row < gsf__codec_end(n, begin); row++) {
        const size_t i = job->rows[row];
        const float opacity = 1.0f / (1.0f + gsf__exp_f32(-s->opacity_logits[i]));
        float q[4];
        double rgba[4];
        gsf__unit_quat(s->quats + 4 * i, q);
        for (size_t k = 0; k < 3; k++) {
            gsf__put_f32(positions + 12 * row + 4 * k, gsf__glb_axes[k] * s->means[3 * i + k]);
            gsf__put_f32(rotations + 16 * row + 4 * k, gsf__glb_axes[k] * q[1 + k]);
            gsf__put_f32(scales + 12 * row + 4 * k, fminf(gsf__exp_f32(s->log_scales[3 * i + k]), FLT_MAX));
            rgba[k] = fmin(fmax(0.5 + (double)(gsf__dc_scale * s->sh[3 * bands * i + k]), 0.0), 1.0);
        }
        gsf__put_f32(rotations + 16 * row + 12, q[0]);
        gsf__put_f32(opacities + 4 * row, opacity);
        for (size_t k = 0; k < bands; k++)
            for (size_t c = 0; c < 3; c++)
                gsf__put_f32(sh + 12 * (n * k + row) + 4 * c, signs[k] * s->sh[3 * (bands * i + k) + c]);
        gsf__transfer_colors(rgba, 3, GSF_COLOR_LINEAR);
        rgba[3] = (double)opacity;
        for (size_t k = 0; k < 4; k++) gsf__store_le(colors + 8 * row + 2 * k, (uint64_t)(rgba[k] * 65535.0 + 0.5), 2);
    }
}

// Appends the JSON: one accessor and one view of the buffer per attribute.
static void gsf__glb_append_json(gsf_context* ctx, const gsf__pack* job, size_t bytes, gsf_buffer* out) {
    const gsf_splats* s = job->splats;
    const int bands = gsf_splat_count_sh(s->sh_degree), columns = GSF__GLB_SH + bands + 1;
    static const char* const kinds[5] = {"", "SCALAR", "", "VEC3", "VEC4"};
    float low[3] = {FLT_MAX, FLT_MAX, FLT_MAX}, high[3] = {-FLT_MAX, -FLT_MAX, -FLT_MAX};
    for (size_t row = 0; row < job->count; row++)
        for (size_t k = 0; k < 3; k++) {
            const float v = gsf__glb_axes[k] * s->means[3 * job->rows[row] + k];
            low[k] = fminf(low[k], v);
            high[k] = fmaxf(high[k], v);
        }
    gsf_append_text(ctx, out,
                    "{\"asset\":{\"version\":\"2.0\",\"generator\":\"gsfixer " GSF_VERSION
                    "\"},\"extensionsUsed\":[\"%s\"],"
                    "\"scene\":0,\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"mesh\":0",
                    gsf__glb_extension);
    if (s->origin[0] != 0.0 || s->origin[1] != 0.0 || s->origin[2] != 0.0)
        gsf_append_text(ctx, out, ",\"translation\":[%.17g,%.17g,%.17g]", (double)gsf__glb_axes[0] * s->origin[0],
                        (double)gsf__glb_axes[1] * s->origin[1], (double)gsf__glb_axes[2] * s->origin[2]);
    gsf_append_text(ctx, out,
                    "}],\"meshes\":[{\"primitives\":[{\"mode\":0,\"extensions\":{\"%s\":{\"kernel\":\"ellipse\","
                    "\"colorSpace\":\"srgb_rec709_display\"}},\"attributes\":{\"POSITION\":0",
                    gsf__glb_extension);
    gsf_append_text(ctx, out, ",\"%s:ROTATION\":1,\"%s:SCALE\":2,\"%s:OPACITY\":3", gsf__glb_extension, gsf__glb_extension,
                    gsf__glb_extension);
    for (int k = 0, degree = 0; k < bands; k++) {
        if (k == (degree + 1) * (degree + 1)) degree++;
        gsf_append_text(ctx, out, ",\"%s:SH_DEGREE_%d_COEF_%d\":%d", gsf__glb_extension, degree, k - degree * degree,
                        GSF__GLB_SH + k);
    }
    gsf_append_text(ctx, out, ",\"COLOR_0\":%d}}]}],\"accessors\":[", columns - 1);
    for (int c = 0; c < columns; c++) {
        const int last = c == columns - 1, size = last ? 4 : gsf__glb_sizes[c < GSF__GLB_SH ? c : GSF__GLB_SH];
        gsf_append_text(ctx, out, "%s{\"bufferView\":%d,\"componentType\":%d,\"count\":%zu,\"type\":\"%s\"%s", c ? "," : "", c,
                        last ? 5123 : 5126, job->count, kinds[size], last ? ",\"normalized\":true" : "");
        if (c == GSF__GLB_POSITION)
            gsf_append_text(ctx, out, ",\"min\":[%.9g,%.9g,%.9g],\"max\":[%.9g,%.9g,%.9g]", (double)low[0], (double)low[1],
                            (double)low[2], (double)high[0], (double)high[1], (double)high[2]);
        gsf_append_text(ctx, out, "}");
    }
    gsf_append_text(ctx, out, "],\"bufferViews\":[");
    for (size_t c = 0, at = 0; c < (size_t)columns; c++) {
        const size_t row = c == (size_t)columns - 1 ? 8 : 4 * (size_t)gsf__glb_sizes[c < GSF__GLB_SH ? c : (size_t)GSF__GLB_SH];
        gsf_append_text(ctx, out, "%s{\"buffer\":0,\"byteOffset\":%zu,\"byteLength\":%zu,\"target\":34962}", c ? "," : "", at,
                        row * job->count);
        at += row * job->count;
    }
    gsf_append_text(ctx, out, "],\"buffers\":[{\"byteLength\":%zu}]}", bytes);
}

static gsf_result gsf__glb_format(gsf_context* ctx, const char* name, const gsf_splats* splats, gsf_buffer* out) {
    char head[GSF__GLB_HEAD + GSF__GLB_CHUNK] = {'g', 'l', 'T', 'F', 2}, chunk[GSF__GLB_CHUNK] = {0};
    const size_t before = out->size;
    gsf__pack job;
    GSF__TRY(gsf__pack_plan(ctx, name, splats, &job));
    const size_t row_bytes = 12 + 16 + 12 + 4 + 12 * (size_t)gsf_splat_count_sh(splats->sh_degree) + 8;
    gsf_result result = GSF_OK;
    if (job.count == 0) result = gsf_fail(ctx, GSF_ERROR_DEGENERATE, "%s: glTF holds no empty list of splats", name);
    else if (job.count > (UINT32_MAX - 65536) / row_bytes)
        result = gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %zu splats exceed glTF's 2^32 bytes", name, job.count);
    if (result == GSF_OK) {
        const size_t bytes = job.count * row_bytes;
        gsf_append_bytes(ctx, out, head, sizeof head);
        gsf__glb_append_json(ctx, &job, bytes, out);
        while (out->size % 4 != before % 4 && !out->failed) gsf_append_bytes(ctx, out, " ", 1);
        const size_t json_size = out->size - before - sizeof head;
        gsf__store_le(chunk, bytes, 4);
        memcpy(chunk + 4, "BIN", 4);
        gsf_append_bytes(ctx, out, chunk, sizeof chunk);
        job.out = gsf__append_rows(ctx, out, job.count, row_bytes);
        if (!job.out) {
            result = GSF_ERROR_OUT_OF_MEMORY;
        } else {
            char* start = out->data + before;
            gsf__store_le(start + 8, out->size - before, 4);
            gsf__store_le(start + 12, json_size, 4);
            memcpy(start + 16, "JSON", 4);
            gsf__parallel_for(ctx, gsf__codec_chunks(job.count), gsf__glb_encode_chunk, &job);
        }
    }
    if (result != GSF_OK) out->size = before;
    gsf__pack_free(ctx, &job);
    return result;
}

GSF_API gsf_result gsf_splat_parse(gsf_context* ctx, const char* name, const void* data, size_t size, gsf_splats* out) {
    const unsigned char* p = (const unsigned char*)data;
    memset(out, 0, sizeof *out);
    switch (gsf__type_of_name(name)) {
        case GSF_SPLAT_PLY: return gsf__parse_ply(ctx, name, data, size, out);
        case GSF_SPLAT_SPLAT: return gsf__splat_parse(ctx, name, data, size, out);
        case GSF_SPLAT_SPZ: return gsf__spz_parse(ctx, name, data, size, out);
        case GSF_SPLAT_GLB: return gsf__glb_parse(ctx, name, data, size, out);
        case GSF_SPLAT_AUTO: break;
    }
    if (size >= 4 && memcmp(p, "ply", 3) == 0) return gsf__parse_ply(ctx, name, data, size, out);
    if (size >= 4 && ((p[0] == 0x1f && p[1] == 0x8b) || memcmp(p, "NGSP", 4) == 0))
        return gsf__spz_parse(ctx, name, data, size, out);
    if (size >= 4 && memcmp(p, "glTF", 4) == 0) return gsf__glb_parse(ctx, name, data, size, out);
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: neither PLY nor SPZ nor GLB (.splat is detected only by name)", name);
}

GSF_API gsf_result gsf_splat_load(gsf_context* ctx, const char* path, gsf_splats* out) {
    void* data;
    size_t size;
    memset(out, 0, sizeof *out);
    GSF__TRY(gsf_read_file(ctx, path, &data, &size));
    const gsf_result result = gsf_splat_parse(ctx, path, data, size, out);
    gsf_free(ctx, data);
    return result;
}

GSF_API gsf_result gsf_splat_format(gsf_context* ctx, const char* name, const gsf_splats* splats,
                                    const gsf_splat_save_desc* desc, gsf_buffer* out) {
    gsf_splat_save_desc d;
    gsf_splats view = *splats;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.type == GSF_SPLAT_AUTO) d.type = gsf__type_of_name(name);
    if (d.local) memset(view.origin, 0, sizeof view.origin);
    switch (d.type) {
        case GSF_SPLAT_PLY: return gsf__format_ply(ctx, &view, out);
        case GSF_SPLAT_SPLAT: return gsf__splat_format(ctx, name, &view, out);
        case GSF_SPLAT_SPZ: return gsf__spz_format(ctx, name, &view, d.spz_version ? d.spz_version : 3, out);
        case GSF_SPLAT_GLB: return gsf__glb_format(ctx, name, &view, out);
        case GSF_SPLAT_AUTO: break;
    }
    return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: does not end in .ply, .splat, .spz or .glb", name);
}

GSF_API gsf_result gsf_splat_save(gsf_context* ctx, const char* path, const gsf_splats* splats,
                                  const gsf_splat_save_desc* desc) {
    gsf_buffer text;
    memset(&text, 0, sizeof text);
    gsf_result result = gsf_splat_format(ctx, path, splats, desc, &text);
    if (result == GSF_OK) result = gsf_write_file(ctx, path, text.data, text.size);
    gsf_destroy_buffer(ctx, &text);
    return result;
}

// ---- >>colmap ------------------------------------------------------------------

/* COLMAP's three files are first read into a gsf__sfm (in file order, with tracks of image ids), which >>scene converts
   to a gsf_scene. transforms.json is read the same way. Binary files, all little-endian:
       cameras.bin   u64 n | n x { u32 id, i32 model, u64 width, u64 height, f64 params[of the model] }
       images.bin    u64 n | n x { u32 id, f64 qw qx qy qz, f64 tx ty tz, u32 camera, char name[] NUL,
                                   u64 m, m x { f64 x y, u64 point } }
       points3D.bin  u64 n | n x { u64 id, f64 x y z, u8 r g b, f64 error, u64 m, m x { u32 image, u32 index } } */

typedef enum gsf__lens_kind {
    GSF__LENS_PINHOLE,
    GSF__LENS_RATIONAL,
    GSF__LENS_FISHEYE,
    GSF__LENS_FOV,
    GSF__LENS_FISHEYE624, // Project Aria's name: 6 radial, 2 tangential, 4 thin prism coefficients
    GSF__LENS_DIVISION,
    GSF__LENS_EUCM,
    GSF__LENS_PANORAMA    // cannot be rectified to a pinhole image, so no gsf__lens is of this kind
} gsf__lens_kind;

typedef struct gsf__lens { // any COLMAP camera, reduced to one of a few kinds; formulas in gsf__lens_distort
    gsf__lens_kind kind;
    int32_t width, height;
    double fx, fy, cx, cy;
    // RATIONAL k1 k2 p1 p2 k3 k4 k5 k6 (OpenCV's order); FISHEYE k1 k2 p1 p2 k3 k4 sx1 sy1; FOV omega;
    // FISHEYE624 k0..k5 p0 p1 s0..s3; DIVISION k; EUCM alpha beta
    double k[12];
} gsf__lens;

typedef struct gsf__sfm_camera {
    uint32_t id;
    gsf__lens lens;
    // transforms.json may omit what can be derived from the photo; see gsf__camera_lens
    int open;                // width = height = 0: the photo's size; cx, cy NaN: its centre
    double angle_x, angle_y; // fields of view in radians, for fx, fy = 0
} gsf__sfm_camera;

typedef struct gsf__sfm_image {
    uint32_t id, camera_id;
    size_t camera;    // index into cameras
    size_t at;        // byte offset or line, for error messages
    double w2c[16];
    const char* name; // inside the source text, not terminated
    size_t name_size;
} gsf__sfm_image;

typedef struct gsf__sfm {
    gsf_scene* scene; // receives the points; tracks hold image ids until gsf__scene_map_tracks
    gsf__sfm_camera* cameras;
    gsf__sfm_image* images;
    size_t camera_count, image_count;
    size_t camera_room, image_room, point_room, track_room;
    size_t dropped_points; // points with a NaN or infinite position
    const char* images_name;
} gsf__sfm;

// Makes room for `count` points, their track_begin included.
static gsf_result gsf__sfm_reserve_points(gsf_context* ctx, gsf__sfm* m, size_t count) {
    gsf_scene* s = m->scene;
    void** const arrays[4] = {(void**)&s->points, (void**)&s->colors, (void**)&s->point_ids, (void**)&s->track_begin};
    const size_t sizes[4] = {3 * sizeof(double), 3, sizeof(uint64_t), sizeof(size_t)};
    const size_t used = m->point_room ? s->point_count + 1 : 0;
    size_t room = 0;
    if (count < m->point_room) return GSF_OK;
    for (int k = 0; k < 4; k++) {
        room = m->point_room;
        GSF__TRY(gsf__reserve(ctx, arrays[k], &room, used, count + 1, sizes[k]));
    }
    m->point_room = room;
    return GSF_OK;
}

static gsf_result gsf__sfm_reserve_tracks(gsf_context* ctx, gsf__sfm* m, size_t used, size_t count) {
    return gsf__reserve(ctx, (void**)&m->scene->track_views, &m->track_room, used, count, sizeof(uint32_t));
}

// Prepares to read a model into an empty scene. No array stays NULL, so that callers of the library need no checks.
static gsf_result gsf__sfm_init(gsf_context* ctx, gsf__sfm* m, gsf_scene* scene) {
    memset(m, 0, sizeof *m);
    memset(scene, 0, sizeof *scene);
    m->scene = scene;
    GSF__TRY(gsf__sfm_reserve_points(ctx, m, 0));
    scene->track_begin[0] = 0;
    return gsf__sfm_reserve_tracks(ctx, m, 0, 1);
}

enum { GSF__LENS_PARAMS_MAX = 16, GSF__LENS_SIZE_MAX = 1000000 };

typedef struct gsf__lens_model { // COLMAP's camera models by id
    const char* name;
    unsigned char param_count, focal_count;
    gsf__lens_kind kind;
    signed char slot[12]; // index into gsf__lens.k of each parameter after the principal point
} gsf__lens_model;

static const gsf__lens_model gsf__lens_models[] = { // COLMAP 3.12 writes the first 12, 4.1 all of them
    {"SIMPLE_PINHOLE", 3, 1, GSF__LENS_PINHOLE, {0}},
    {"PINHOLE", 4, 2, GSF__LENS_PINHOLE, {0}},
    {"SIMPLE_RADIAL", 4, 1, GSF__LENS_RATIONAL, {0}},
    {"RADIAL", 5, 1, GSF__LENS_RATIONAL, {0, 1}},
    {"OPENCV", 8, 2, GSF__LENS_RATIONAL, {0, 1, 2, 3}},
    {"OPENCV_FISHEYE", 8, 2, GSF__LENS_FISHEYE, {0, 1, 4, 5}},
    {"FULL_OPENCV", 12, 2, GSF__LENS_RATIONAL, {0, 1, 2, 3, 4, 5, 6, 7}},
    {"FOV", 5, 2, GSF__LENS_FOV, {0}},
    {"SIMPLE_RADIAL_FISHEYE", 4, 1, GSF__LENS_FISHEYE, {0}},
    {"RADIAL_FISHEYE", 5, 1, GSF__LENS_FISHEYE, {0, 1}},
    {"THIN_PRISM_FISHEYE", 12, 2, GSF__LENS_FISHEYE, {0, 1, 2, 3, 4, 5, 6, 7}},
    {"RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, GSF__LENS_FISHEYE624, {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11}},
    {"SIMPLE_DIVISION", 4, 1, GSF__LENS_DIVISION, {0}},
    {"DIVISION", 5, 2, GSF__LENS_DIVISION, {0}},
    {"SIMPLE_FISHEYE", 3, 1, GSF__LENS_FISHEYE, {0}},
    {"FISHEYE", 4, 2, GSF__LENS_FISHEYE, {0}},
    {"EUCM", 6, 2, GSF__LENS_EUCM, {0, 1}},
    {"EQUIRECTANGULAR", 2, 0, GSF__LENS_PANORAMA, {0}},
};

// Returns what makes the lens of a camera invalid, as the end of an error message; NULL if it is valid.
static const char* gsf__lens_fault(const gsf__lens* lens) {
    const double* k = lens->k;
    if (!(lens->fx > 0.0 && lens->fy > 0.0)) return "a focal length is not above 0";
    if (lens->kind == GSF__LENS_FOV && !(fabs(k[0]) < 3.1)) return "omega is not below pi";
    if (lens->kind == GSF__LENS_EUCM && !(k[0] >= 0.0 && k[0] <= 1.0)) return "alpha is not in 0..1";
    if (lens->kind == GSF__LENS_EUCM && !(k[1] > 0.0)) return "beta is not above 0";
    return NULL;
}

// Builds a lens from a camera model and its parameters. A lens without distortion becomes a pinhole, so that its photos
// are used without resampling.
static gsf__lens gsf__lens_from_params(const gsf__lens_model* info, int32_t width, int32_t height,
                                       const double* params) {
    gsf__lens lens;
    memset(&lens, 0, sizeof lens);
    lens.kind = info->kind;
    lens.width = width;
    lens.height = height;
    lens.fx = params[0];
    lens.fy = params[info->focal_count - 1];
    lens.cx = params[info->focal_count];
    lens.cy = params[info->focal_count + 1];
    int zero = 1;
    for (int i = info->focal_count + 2; i < info->param_count; i++) {
        lens.k[info->slot[i - info->focal_count - 2]] = params[i];
        zero = zero && params[i] == 0.0;
    }
    const int fisheye = lens.kind == GSF__LENS_FISHEYE || lens.kind == GSF__LENS_FISHEYE624;
    if (lens.kind == GSF__LENS_EUCM ? lens.k[0] == 0.0 : zero && !fisheye) lens.kind = GSF__LENS_PINHOLE;
    return lens;
}

static gsf_result gsf__sfm_push_camera(gsf_context* ctx, gsf__sfm* m, const gsf__sfm_camera* camera) {
    GSF__TRY(gsf__reserve(ctx, (void**)&m->cameras, &m->camera_room, m->camera_count, m->camera_count + 1,
                          sizeof *m->cameras));
    m->cameras[m->camera_count++] = *camera;
    return GSF_OK;
}

static gsf_result gsf__sfm_push_image(gsf_context* ctx, gsf__sfm* m, const gsf__sfm_image* image) {
    GSF__TRY(gsf__reserve(ctx, (void**)&m->images, &m->image_room, m->image_count, m->image_count + 1,
                          sizeof *m->images));
    m->images[m->image_count++] = *image;
    return GSF_OK;
}

static int gsf__compare_ids(const void* a, const void* b) { // of cameras or of images: the first member of both
    const uint32_t x = *(const uint32_t*)a, y = *(const uint32_t*)b;
    return (x > y) - (x < y);
}

// Validates and adds a camera. name, at: its file and position, for error messages. params: as many as the model has.
static gsf_result gsf__sfm_add_camera(gsf_context* ctx, gsf__sfm* m, const char* name, size_t at, uint32_t id,
                                      int model, uint64_t width, uint64_t height, const double* params) {
    const gsf__lens_model* info = &gsf__lens_models[model];
    gsf__sfm_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.id = id;
    if (info->kind == GSF__LENS_PANORAMA)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED,
                        "%s:%zu: camera %u: %s photos are panoramas; cut perspective ones of them first (COLMAP's "
                        "panorama_sfm.py does)", name, at, (unsigned)id, info->name);
    for (int i = 0; i < info->param_count; i++)
        if (!isfinite(params[i]))
            return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s:%zu: camera %u: parameter %d is not finite", name, at,
                            (unsigned)id, i);
    if (width < 1 || height < 1 || width > GSF__LENS_SIZE_MAX || height > GSF__LENS_SIZE_MAX)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: camera %u: image size %llu x %llu", name, at, (unsigned)id,
                        (unsigned long long)width, (unsigned long long)height);
    camera.lens = gsf__lens_from_params(info, (int32_t)width, (int32_t)height, params);
    const char* fault = gsf__lens_fault(&camera.lens);
    if (fault)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: camera %u: %s: %s", name, at, (unsigned)id, info->name, fault);
    return gsf__sfm_push_camera(ctx, m, &camera);
}

// Converts a quaternion (w x y z, any non-zero length) and a translation to a world-to-camera matrix. Returns 0 if they
// are not a valid pose.
static int gsf__pose_from_quaternion(const double q_in[4], const double t[3], double w2c[16]) {
    double q[4], largest = 0.0, norm = 0.0;
    for (int i = 0; i < 4; i++) {
        if (!isfinite(q_in[i])) return 0;
        largest = fmax(largest, fabs(q_in[i]));
    }
    if (!(largest > 0.0)) return 0;
    for (int i = 0; i < 4; i++) q[i] = q_in[i] / largest, norm += q[i] * q[i];
    norm = sqrt(norm);
    for (int i = 0; i < 4; i++) q[i] /= norm;
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z),     2 * (x * z - w * y), // column-major
                         2 * (x * y - w * z),     1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                         2 * (x * z + w * y),     2 * (y * z - w * x),     1 - 2 * (x * x + y * y)};
    memset(w2c, 0, 16 * sizeof(double));
    for (int c = 0; c < 3; c++) {
        for (int i = 0; i < 3; i++) w2c[4 * c + i] = r[3 * c + i];
        if (!(fabs(t[c]) < 1e100)) return 0; // keeps the camera centre finite
        w2c[12 + c] = t[c];
    }
    w2c[15] = 1.0;
    return 1;
}

static gsf_result gsf__sfm_add_image(gsf_context* ctx, gsf__sfm* m, const char* name, size_t at, uint32_t id,
                                     const double pose[7], uint32_t camera_id, const char* image, size_t image_size) {
    gsf__sfm_image out;
    const gsf__sfm_camera* camera = (const gsf__sfm_camera*)bsearch(&camera_id, m->cameras, m->camera_count,
                                                                    sizeof *m->cameras, gsf__compare_ids);
    if (!camera)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: image %u: camera %u does not exist", name, at, (unsigned)id,
                        (unsigned)camera_id);
    if (image_size == 0 || memchr(image, 0, image_size))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: image %u: empty or malformed name", name, at, (unsigned)id);
    if (!gsf__pose_from_quaternion(pose, pose + 4, out.w2c))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC,
                        "%s:%zu: image %u: pose %g %g %g %g, %g %g %g is not a rotation and translation", name, at,
                        (unsigned)id, pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6]);
    out.id = id;
    out.camera_id = camera_id;
    out.camera = (size_t)(camera - m->cameras);
    out.at = at;
    out.name = image;
    out.name_size = image_size;
    return gsf__sfm_push_image(ctx, m, &out);
}

// Adds a point with an empty track. A point with a non-finite position is only counted (*added = 0).
static gsf_result gsf__sfm_add_point(gsf_context* ctx, gsf__sfm* m, uint64_t id, const double xyz[3],
                                     const uint8_t rgb[3], int* added) {
    gsf_scene* s = m->scene;
    const size_t n = s->point_count;
    *added = isfinite(xyz[0]) && isfinite(xyz[1]) && isfinite(xyz[2]);
    if (!*added) {
        m->dropped_points++;
        return GSF_OK;
    }
    GSF__TRY(gsf__sfm_reserve_points(ctx, m, n + 1));
    memcpy(s->points + 3 * n, xyz, 3 * sizeof(double));
    memcpy(s->colors + 3 * n, rgb, 3);
    s->point_ids[n] = id;
    s->track_begin[n + 1] = s->track_begin[n];
    s->point_count++;
    return GSF_OK;
}

// One of the three files being read. A binary and a text file have the same fields in the same order, so one function
// reads a record of either; the numbers of bytes that it passes apply to binary files, `what` to messages about text.
typedef struct gsf__reader {
    const char* name;
    int32_t is_text;
    const char *data, *at, *end; // the file, what is next in it, its end (text: of the current line)
    const char *next, *file_end; // text: the lines not yet read
    size_t line;                 // text: number of the current line, from 1
} gsf__reader;

static gsf__reader gsf__make_reader(const gsf_bytes* bytes, int32_t is_text, const char* binary, const char* text) {
    gsf__reader r;
    memset(&r, 0, sizeof r);
    r.name = bytes->name ? bytes->name : is_text ? text : binary;
    r.is_text = is_text;
    r.data = r.at = r.end = r.next = (const char*)(bytes->data ? bytes->data : "");
    r.file_end = r.data + (bytes->data ? bytes->size : 0);
    if (!is_text) r.end = r.file_end;
    return r;
}

static size_t gsf__position(const gsf__reader* r) { return r->is_text ? r->line : (size_t)(r->at - r->data); }

static void gsf__skip_blanks(gsf__reader* r) {
    while (r->at < r->end && gsf__is_blank((unsigned char)*r->at)) r->at++;
}

static int gsf__next_line(gsf__reader* r) { // 0 at the end of the file
    if (r->next == r->file_end) return 0;
    const char* stop = (const char*)memchr(r->next, '\n', (size_t)(r->file_end - r->next));
    r->at = r->next;
    r->end = stop ? stop : r->file_end;
    r->next = stop ? stop + 1 : r->file_end;
    r->line++;
    return 1;
}

// Checks that `bytes` more bytes follow, for the fields that are read next.
static gsf_result gsf__need(gsf_context* ctx, const gsf__reader* r, size_t bytes, const char* what) {
    if (r->is_text || bytes <= (size_t)(r->end - r->at)) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: file ends inside %s", r->name, gsf__position(r), what);
}

// Reads a count of records of at least `record` bytes each and checks it against the rest of the file. Text has none.
static gsf_result gsf__read_count(gsf_context* ctx, gsf__reader* r, size_t record, const char* what, size_t* out) {
    *out = 0;
    if (r->is_text) return GSF_OK;
    GSF__TRY(gsf__need(ctx, r, 8, what));
    const uint64_t count = gsf__load_le(r->at, 8);
    if (count > ((size_t)(r->end - r->at) - 8) / record)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %llu %s do not fit the file", r->name, gsf__position(r),
                        (unsigned long long)count, what);
    r->at += 8;
    *out = (size_t)count;
    return GSF_OK;
}

// Goes to the next of `left` records; in text, to the next line that is neither empty nor a comment. Returns 0 if there
// is none.
static int gsf__next_record(gsf__reader* r, size_t* left) {
    if (!r->is_text) return (*left)-- > 0;
    while (gsf__next_line(r)) {
        gsf__skip_blanks(r);
        if (r->at < r->end && *r->at != '#') return 1;
    }
    return 0;
}

static gsf_result gsf__unexpected(gsf_context* ctx, const gsf__reader* r, const char* what, const char* word,
                                  size_t length) {
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: expected %s, got \"%.*s\"", r->name, r->line, what,
                    (int)(length < 40 ? length : 40), word);
}

static gsf_result gsf__parse_uint(gsf_context* ctx, gsf__reader* r, uint64_t most, const char* what, uint64_t* out) {
    const char* word;
    const size_t length = gsf__next_word(&r->at, r->end, &word);
    if (gsf__word_u64(word, length, out) && *out <= most) return GSF_OK;
    return gsf__unexpected(ctx, r, what, word, length);
}

static inline gsf_result gsf__read_uint(gsf_context* ctx, gsf__reader* r, int bytes, const char* what, uint64_t* out) {
    if (r->is_text) return gsf__parse_uint(ctx, r, UINT64_MAX >> (64 - 8 * bytes), what, out);
    *out = gsf__load_le(r->at, bytes);
    r->at += bytes;
    return GSF_OK;
}

static gsf_result gsf__read_doubles(gsf_context* ctx, gsf__reader* r, int count, const char* what, double* out) {
    for (int k = 0; k < count; k++) {
        const char* word;
        if (!r->is_text) {
            out[k] = gsf__load_f64(r->at);
            r->at += 8;
            continue;
        }
        const size_t length = gsf__next_word(&r->at, r->end, &word);
        if (!length || !gsf__word_double(word, length, &out[k])) return gsf__unexpected(ctx, r, what, word, length);
    }
    return GSF_OK;
}

// After the last record.
static gsf_result gsf__reader_end(gsf_context* ctx, const gsf__reader* r) {
    if (r->is_text || r->at == r->end) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %zu bytes after the last record", r->name, gsf__position(r),
                    (size_t)(r->end - r->at));
}

// Reads a camera's model: its id, in text its name.
static gsf_result gsf__read_model(gsf_context* ctx, gsf__reader* r, uint64_t camera, uint32_t* model) {
    const size_t at = gsf__position(r);
    char shown[48];
    if (r->is_text) {
        const char* word;
        const size_t length = gsf__next_word(&r->at, r->end, &word);
        for (*model = 0; *model < GSF__COUNT(gsf__lens_models); (*model)++)
            if (gsf__word_is(word, length, gsf__lens_models[*model].name)) break;
        snprintf(shown, sizeof shown, "\"%.*s\"", (int)(length < 40 ? length : 40), word);
    } else {
        *model = (uint32_t)gsf__load_le(r->at, 4);
        r->at += 4;
        snprintf(shown, sizeof shown, "%d", (int)*model);
    }
    if (*model < GSF__COUNT(gsf__lens_models)) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED,
                    "%s:%zu: camera %u: unknown camera model %s (colmap image_undistorter makes pinhole cameras of it)",
                    r->name, at, (unsigned)camera, shown);
}

static gsf_result gsf__read_cameras(gsf_context* ctx, gsf__reader* r, gsf__sfm* m) {
    uint64_t id = 0, width = 0, height = 0;
    uint32_t model = 0;
    double params[GSF__LENS_PARAMS_MAX];
    const char* word;
    size_t left;
    GSF__TRY(gsf__read_count(ctx, r, 24 + 2 * 8, "cameras", &left));
    while (gsf__next_record(r, &left)) {
        const size_t at = gsf__position(r);
        GSF__TRY(gsf__need(ctx, r, 24, "a camera"));
        GSF__TRY(gsf__read_uint(ctx, r, 4, "a camera id", &id));
        GSF__TRY(gsf__read_model(ctx, r, id, &model));
        GSF__TRY(gsf__read_uint(ctx, r, 8, "a width", &width));
        GSF__TRY(gsf__read_uint(ctx, r, 8, "a height", &height));
        const gsf__lens_model* info = &gsf__lens_models[model];
        GSF__TRY(gsf__need(ctx, r, 8u * info->param_count, "a camera's parameters"));
        GSF__TRY(gsf__read_doubles(ctx, r, info->param_count, "a camera parameter", params));
        if (r->is_text && gsf__next_word(&r->at, r->end, &word))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: camera %u: %s takes %d parameters, found more", r->name,
                            r->line, (unsigned)id, info->name, (int)info->param_count);
        GSF__TRY(gsf__sfm_add_camera(ctx, m, r->name, at, (uint32_t)id, (int)model, width, height, params));
    }
    GSF__TRY(gsf__reader_end(ctx, r));
    if (m->camera_count == 0) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no camera in the file", r->name);
    qsort(m->cameras, m->camera_count, sizeof *m->cameras, gsf__compare_ids);
    for (size_t i = 1; i < m->camera_count; i++)
        if (m->cameras[i].id == m->cameras[i - 1].id)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: camera %u occurs twice", r->name, (unsigned)m->cameras[i].id);
    return GSF_OK;
}

// Reads an image's name: up to a NUL, in text the rest of the line, which may contain spaces.
static gsf_result gsf__read_image_name(gsf_context* ctx, gsf__reader* r, const char** name, size_t* size) {
    const char* stop = r->end;
    if (r->is_text) {
        gsf__skip_blanks(r);
        while (stop > r->at && gsf__is_blank((unsigned char)stop[-1])) stop--;
    } else {
        stop = (const char*)memchr(r->at, 0, (size_t)(r->end - r->at));
        if (!stop)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: unterminated image name", r->name, gsf__position(r));
    }
    *name = r->at;
    *size = (size_t)(stop - r->at);
    r->at = r->is_text ? r->end : stop + 1;
    return GSF_OK;
}

// Skips an image's 2D points. In text they have a line of their own, which may be empty, or missing at the end of the
// file.
static gsf_result gsf__skip_observations(gsf_context* ctx, gsf__reader* r) {
    const char* word;
    size_t count, values = 0;
    GSF__TRY(gsf__read_count(ctx, r, 24, "2D points", &count));
    r->at += 24 * count;
    if (r->is_text && gsf__next_line(r))
        while (gsf__next_word(&r->at, r->end, &word)) values++;
    if (values % 3 == 0) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %zu values, expected 2D points as X Y POINT3D_ID", r->name, r->line,
                    values);
}

static gsf_result gsf__read_images(gsf_context* ctx, gsf__reader* r, gsf__sfm* m) {
    uint64_t id = 0, camera = 0;
    double pose[7];
    const char* image = NULL;
    size_t left, image_size = 0;
    GSF__TRY(gsf__read_count(ctx, r, 64 + 2 + 8, "images", &left));
    while (gsf__next_record(r, &left)) {
        const size_t at = gsf__position(r);
        GSF__TRY(gsf__need(ctx, r, 64, "an image"));
        GSF__TRY(gsf__read_uint(ctx, r, 4, "an image id", &id));
        GSF__TRY(gsf__read_doubles(ctx, r, 7, "a pose (QW QX QY QZ TX TY TZ)", pose));
        GSF__TRY(gsf__read_uint(ctx, r, 4, "a camera id", &camera));
        GSF__TRY(gsf__read_image_name(ctx, r, &image, &image_size));
        GSF__TRY(gsf__skip_observations(ctx, r));
        GSF__TRY(gsf__sfm_add_image(ctx, m, r->name, at, (uint32_t)id, pose, (uint32_t)camera, image, image_size));
    }
    return gsf__reader_end(ctx, r);
}

// Reads the track of a point: `count` entries, in text those up to the end of the line. added: it is the last point of
// the model; else the track is dropped.
static gsf_result gsf__read_track(gsf_context* ctx, gsf__reader* r, size_t count, int added, gsf__sfm* m) {
    gsf_scene* s = m->scene;
    uint64_t image = 0, index;
    size_t end = s->track_begin[s->point_count];
    GSF__TRY(gsf__sfm_reserve_tracks(ctx, m, end, end + count));
    for (size_t k = 0; k < count; k++) s->track_views[end++] = (uint32_t)gsf__load_le(r->at + 8 * k, 4);
    r->at += 8 * count;
    if (r->is_text)
        for (gsf__skip_blanks(r); r->at < r->end; gsf__skip_blanks(r)) {
            GSF__TRY(gsf__read_uint(ctx, r, 4, "an image id", &image));
            GSF__TRY(gsf__read_uint(ctx, r, 4, "a 2D point index", &index));
            GSF__TRY(gsf__sfm_reserve_tracks(ctx, m, end, end + 1));
            s->track_views[end++] = (uint32_t)image;
        }
    if (added) s->track_begin[s->point_count] = end;
    return GSF_OK;
}

static gsf_result gsf__read_points(gsf_context* ctx, gsf__reader* r, gsf__sfm* m) {
    uint64_t id = 0, value = 0;
    double xyz[3], error;
    uint8_t rgb[3];
    size_t left, track;
    int added;
    GSF__TRY(gsf__read_count(ctx, r, 43 + 8, "points", &left));
    // Allocates once: all bytes of a binary file that are not the fixed part of a record are track entries.
    GSF__TRY(gsf__sfm_reserve_points(ctx, m, left));
    if (!r->is_text) GSF__TRY(gsf__sfm_reserve_tracks(ctx, m, 0, ((size_t)(r->end - r->at) - 51 * left) / 8));
    while (gsf__next_record(r, &left)) {
        GSF__TRY(gsf__need(ctx, r, 43, "a point"));
        GSF__TRY(gsf__read_uint(ctx, r, 8, "a point id", &id));
        GSF__TRY(gsf__read_doubles(ctx, r, 3, "a coordinate", xyz));
        for (int k = 0; k < 3; k++) {
            GSF__TRY(gsf__read_uint(ctx, r, 1, "a colour 0..255", &value));
            rgb[k] = (uint8_t)value;
        }
        GSF__TRY(gsf__read_doubles(ctx, r, 1, "the reprojection error", &error));
        GSF__TRY(gsf__read_count(ctx, r, 8, "track entries", &track));
        GSF__TRY(gsf__sfm_add_point(ctx, m, id, xyz, rgb, &added));
        GSF__TRY(gsf__read_track(ctx, r, track, added, m));
    }
    return gsf__reader_end(ctx, r);
}

// points: may be NULL. The image names in *m point into `images`.
static gsf_result gsf__colmap_read(gsf_context* ctx, int32_t is_text, const gsf_bytes* cameras, const gsf_bytes* images,
                                   const gsf_bytes* points, gsf__sfm* m) {
    gsf__reader r = gsf__make_reader(cameras, is_text, "cameras.bin", "cameras.txt");
    GSF__TRY(gsf__read_cameras(ctx, &r, m));
    r = gsf__make_reader(images, is_text, "images.bin", "images.txt");
    m->images_name = r.name;
    GSF__TRY(gsf__read_images(ctx, &r, m));
    if (!points) return GSF_OK;
    r = gsf__make_reader(points, is_text, "points3D.bin", "points3D.txt");
    return gsf__read_points(ctx, &r, m);
}

// ---- >>transforms --------------------------------------------------------------

/* transforms.json of nerfstudio and instant-ngp: an object with "frames": [{"file_path", "transform_matrix" (camera to
   world, OpenGL axes: x right, y up, z backward)}]. Intrinsics (w h fl_x fl_y cx cy k1..k4 p1 p2 camera_model, or
   camera_angle_x / camera_angle_y) are given at the top level; a frame may override them. World coordinates are kept as
   in the file: nerfstudio's applied_transform has already been applied to the cameras and to the points of
   ply_file_path, and instant-ngp's scale, offset and aabb_scale only place its own grid. */

// What a frame may override: numbers, in the order of gsf__transforms_add_camera, and what kind of camera it is.
enum { GSF__TRANSFORMS_CX = 12, GSF__TRANSFORMS_NUMBERS = 14 };
static const char* const gsf__transforms_keys[GSF__TRANSFORMS_NUMBERS + 2] = {
    "k1",   "k2",   "p1",             "p2",             "k3", "k4", "w",            "h",
    "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "cx", "cy", "camera_model", "is_fisheye"};

// Finds a member of the frame, else of the top level.
static const gsf_json_value* gsf__transforms_find(const gsf_json* json, const gsf_json_value* frame, const char* key) {
    const gsf_json_value* value = gsf_find_json_member(json, frame, key);
    return value ? value : gsf_find_json_member(json, &json->values[0], key);
}

static gsf_result gsf__transforms_lens_kind(gsf_context* ctx, const gsf_json* json, const gsf_json_value* frame,
                                            gsf__lens_kind* out) {
    static const char* const perspective[6] = {"OPENCV", "PINHOLE",     "SIMPLE_PINHOLE",
                                               "RADIAL", "FULL_OPENCV", "SIMPLE_RADIAL"};
    const gsf_json_value* model = gsf__transforms_find(json, frame, "camera_model");
    const gsf_json_value* fisheye = gsf__transforms_find(json, frame, "is_fisheye"); // instant-ngp
    *out = fisheye && fisheye->type == GSF_JSON_TRUE ? GSF__LENS_FISHEYE : GSF__LENS_RATIONAL;
    if (!model) return GSF_OK;
    const char* name = model->type == GSF_JSON_STRING ? model->string : "";
    for (int i = 0; i < 6; i++)
        if (strcmp(name, perspective[i]) == 0) return GSF_OK;
    *out = GSF__LENS_FISHEYE;
    if (strcmp(name, "OPENCV_FISHEYE") == 0) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s:%u: camera_model \"%.40s\" is not supported", json->name,
                    (unsigned)model->offset, name);
}

// Adds the camera of a frame (NULL: of the top level) to the model.
static gsf_result gsf__transforms_add_camera(gsf_context* ctx, const gsf_json* json, const gsf_json_value* frame,
                                             gsf__sfm* m) {
    const unsigned at = (unsigned)(frame ? frame->offset : 0);
    gsf__sfm_camera camera;
    double width, height;
    int distorted = 0;
    memset(&camera, 0, sizeof camera);
    gsf__lens* lens = &camera.lens;
    double* const k = lens->k;
    double* const numbers[GSF__TRANSFORMS_NUMBERS] = {
        k,         k + 1,     k + 2,           k + 3,           k + 4,     k + 5,     &width,
        &height,   &lens->fx, &lens->fy,       &camera.angle_x, &camera.angle_y, &lens->cx, &lens->cy};
    camera.id = (uint32_t)m->camera_count;
    camera.open = 1;
    GSF__TRY(gsf__transforms_lens_kind(ctx, json, frame, &lens->kind));
    for (int i = 0; i < GSF__TRANSFORMS_NUMBERS; i++) {
        const gsf_json_value* value = gsf__transforms_find(json, frame, gsf__transforms_keys[i]);
        if (value && value->type != GSF_JSON_NUMBER)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: \"%s\" is not a number", json->name,
                            (unsigned)value->offset, gsf__transforms_keys[i]);
        *numbers[i] = value ? value->number : i < GSF__TRANSFORMS_CX ? 0.0 : (double)NAN;
    }
    for (int i = 0; i < 6; i++) distorted = distorted || k[i] != 0.0;
    if (lens->kind == GSF__LENS_RATIONAL && !distorted) lens->kind = GSF__LENS_PINHOLE;
    const double size_max = (double)GSF__LENS_SIZE_MAX;
    if (!(width >= 0.0 && height >= 0.0 && width <= size_max && height <= size_max &&
          (width >= 1.0) == (height >= 1.0)))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: image size %g x %g", json->name, at, width, height);
    lens->width = (int32_t)width;
    lens->height = (int32_t)height;
    const double pi = 3.14159265358979;
    if (!(lens->fx > 0.0) && !(camera.angle_x > 0.0 && camera.angle_x < pi))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: neither fl_x > 0 nor camera_angle_x between 0 and pi",
                        json->name, at);
    if (lens->fx < 0.0 || lens->fy < 0.0 || camera.angle_y < 0.0 || camera.angle_y > pi)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: negative focal length or field of view", json->name, at);
    return gsf__sfm_push_camera(ctx, m, &camera);
}

static int gsf__transforms_has_camera(const gsf_json* json, const gsf_json_value* frame) {
    for (size_t i = 0; i < GSF__COUNT(gsf__transforms_keys); i++)
        if (gsf_find_json_member(json, frame, gsf__transforms_keys[i])) return 1;
    return 0;
}

// Converts a row-major OpenGL camera-to-world matrix to an OpenCV world-to-camera matrix. Returns 0 if the 3x3 part is
// not a rotation (times a scale).
static int gsf__pose_from_opengl(const double rows[12], double w2c[16]) {
    double axis[3][3], c2w[16];
    for (int c = 0; c < 3; c++) {
        double length = 0.0;
        for (int r = 0; r < 3; r++) axis[c][r] = rows[4 * r + c], length += axis[c][r] * axis[c][r];
        length = sqrt(length);
        if (!(length > 1e-9 && length < 1e9)) return 0;
        for (int r = 0; r < 3; r++) axis[c][r] /= length;
    }
    const double* x = axis[0];
    double *y = axis[1], *z = axis[2];
    for (int a = 0; a < 3; a++)
        for (int b = a + 1; b < 3; b++)
            if (fabs(axis[a][0] * axis[b][0] + axis[a][1] * axis[b][1] + axis[a][2] * axis[b][2]) > 1e-2) return 0;
    const double cross[3] = {x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]};
    if (cross[0] * z[0] + cross[1] * z[1] + cross[2] * z[2] < 0.0) return 0; // mirrored
    const double norm = sqrt(cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]);
    for (int r = 0; r < 3; r++) z[r] = cross[r] / norm; // orthonormalise: z from x and y, then y from z and x
    y[0] = z[1] * x[2] - z[2] * x[1];
    y[1] = z[2] * x[0] - z[0] * x[2];
    y[2] = z[0] * x[1] - z[1] * x[0];
    memset(c2w, 0, sizeof c2w);
    for (int r = 0; r < 3; r++) {
        c2w[r] = x[r];
        c2w[4 + r] = -y[r];
        c2w[8 + r] = -z[r];
        c2w[12 + r] = rows[4 * r + 3];
        if (!(fabs(c2w[12 + r]) < 1e100)) return 0;
    }
    c2w[15] = 1.0;
    gsf__mat4_rigid_inverse(c2w, w2c);
    return 1;
}

static gsf_result gsf__transforms_add_frame(gsf_context* ctx, const gsf_json* json, const gsf_json_value* frame,
                                            size_t camera, gsf__sfm* m) {
    const gsf_json_value* path = gsf_find_json_member(json, frame, "file_path");
    const gsf_json_value* matrix = gsf_find_json_member(json, frame, "transform_matrix");
    double rows[12];
    if (!path || path->type != GSF_JSON_STRING)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: frame without file_path", json->name, (unsigned)frame->offset);
    if (!matrix || matrix->type != GSF_JSON_ARRAY || (matrix->count != 4 && matrix->count != 3))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: frame without a 4x4 transform_matrix", json->name,
                        (unsigned)frame->offset);
    for (size_t r = 0; r < 3; r++) {
        const gsf_json_value* row = gsf_find_json_element(json, matrix, r);
        for (size_t c = 0; c < 4; c++) {
            const gsf_json_value* value =
                row && row->type == GSF_JSON_ARRAY && row->count == 4 ? gsf_find_json_element(json, row, c) : NULL;
            if (!value || value->type != GSF_JSON_NUMBER)
                return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: transform_matrix is not a 4x4 matrix of numbers",
                                json->name, (unsigned)matrix->offset);
            rows[4 * r + c] = value->number;
        }
    }
    gsf__sfm_image image;
    if (!gsf__pose_from_opengl(rows, image.w2c))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: transform_matrix is not a rotation and translation", json->name,
                        (unsigned)matrix->offset);
    image.name = path->string;
    image.name_size = path->string_size;
    while (image.name_size > 2 && image.name[0] == '.' && image.name[1] == '/') image.name += 2, image.name_size -= 2;
    image.id = (uint32_t)m->image_count + 1;
    image.camera = camera;
    image.camera_id = (uint32_t)camera;
    image.at = path->offset;
    return gsf__sfm_push_image(ctx, m, &image);
}

// The image names in *m point into `json`.
static gsf_result gsf__transforms_read(gsf_context* ctx, const gsf_json* json, gsf__sfm* m) {
    const gsf_json_value* frames = gsf_find_json_member(json, &json->values[0], "frames");
    size_t shared = SIZE_MAX;
    m->images_name = json->name;
    if (!frames || frames->type != GSF_JSON_ARRAY)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:0: no \"frames\" array", json->name);
    for (uint32_t i = frames->child; i; i = json->values[i].next) {
        const gsf_json_value* frame = &json->values[i];
        if (frame->type != GSF_JSON_OBJECT)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%u: a frame is not an object", json->name,
                            (unsigned)frame->offset);
        const int own = gsf__transforms_has_camera(json, frame);
        size_t camera = own ? m->camera_count : shared;
        if (camera == SIZE_MAX) camera = shared = m->camera_count;
        if (camera == m->camera_count) GSF__TRY(gsf__transforms_add_camera(ctx, json, own ? frame : NULL, m));
        GSF__TRY(gsf__transforms_add_frame(ctx, json, frame, camera, m));
    }
    return GSF_OK;
}

// Reads a plain point cloud into the model: x y z and optional red green blue (0..255, or 0..1 for float types).
static gsf_result gsf__transforms_read_points(gsf_context* ctx, const char* name, const void* data, size_t size,
                                              gsf__sfm* m) {
    gsf__ply ply;
    double* values;
    GSF__TRY(gsf__ply_read_header(ctx, name, data, size, &ply));
    for (int k = 0; k < 3; k++)
        if (ply.type[k] == GSF__PLY_ABSENT)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: no points: column x, y or z is missing", name, ply.body);
    gsf_result result = gsf__ply_parse_text(ctx, &ply, &values);
    for (size_t i = 0; i < ply.count && result == GSF_OK; i++) {
        double xyz[3];
        uint8_t rgb[3];
        int added;
        gsf__ply_position(&ply, i, xyz);
        for (int k = 0; k < 3; k++) {
            const int slot = GSF__PLY_RED + k;
            const gsf__ply_type type = ply.type[slot];
            double value = type == GSF__PLY_ABSENT ? 128.0 : gsf__ply_cell(&ply, gsf__ply_row(&ply, i), slot);
            if (type == GSF__PLY_F32 || type == GSF__PLY_F64) value *= 255.0;
            rgb[k] = (uint8_t)(value > 0.0 ? (value < 255.0 ? value + 0.5 : 255.0) : 0.0);
        }
        result = gsf__sfm_add_point(ctx, m, i, xyz, rgb, &added);
    }
    gsf_free(ctx, values);
    return result;
}

// ---- >>undistort ---------------------------------------------------------------

// atan(t)/t for t >= 0: two exact range reductions to |z| <= tan(pi/8), then the power series; error below 1e-12.
static double gsf__atan_ratio(double t) {
    const double pi = 3.14159265358979323846;
    double z = t, base = 0.0, sign = 1.0;
    if (t < 1e-4) return 1.0 - t * t / 3.0;
    if (z > 1.0) {
        z = 1.0 / z;
        base = pi / 2;
        sign = -1.0;
    }
    if (z > 0.41421356237309503) {
        z = (z - 1.0) / (z + 1.0);
        base += sign * pi / 4;
    }
    const double s = z * z;
    double series = 0.0;
    for (int n = 29; n >= 1; n -= 2) series = 1.0 / n - s * series;
    return (base + sign * z * series) / t;
}

// Maps the undistorted ray (x, y, 1) to the distorted normalised image point (u, v), which is the pixel
// (fx u + cx, fy v + cy). The formulas are those of COLMAP's sensor/models.h (RATIONAL: OpenCV's), without the Taylor
// expansions near zero in FOV. NaN for rays that the lens cannot image.
static void gsf__lens_distort(const gsf__lens* lens, double x, double y, double* u, double* v) {
    const double* k = lens->k;
    const double r2 = x * x + y * y;
    double scale = 1.0;
    switch (lens->kind) {
        case GSF__LENS_PINHOLE:
        case GSF__LENS_PANORAMA: break;
        case GSF__LENS_RATIONAL:
            scale = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])));
            *u = x * scale + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x);
            *v = y * scale + 2.0 * k[3] * x * y + k[2] * (r2 + 2.0 * y * y);
            return;
        case GSF__LENS_FISHEYE: {
            scale = gsf__atan_ratio(sqrt(r2));
            const double a = x * scale, b = y * scale, t2 = r2 * scale * scale; // t = angle to the optical axis
            const double radial = 1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[4] + t2 * k[5])));
            *u = a * radial + 2.0 * k[2] * a * b + k[3] * (t2 + 2.0 * a * a) + k[6] * t2;
            *v = b * radial + 2.0 * k[3] * a * b + k[2] * (t2 + 2.0 * b * b) + k[7] * t2;
            return;
        }
        case GSF__LENS_FOV: // k[1] = 2 tan(omega/2), k[2] = k[1]/omega, set by gsf__rectify_make
            scale = k[2] * gsf__atan_ratio(k[1] * sqrt(r2));
            break;
        case GSF__LENS_FISHEYE624: { // unlike in FISHEYE, the other terms act on the radially distorted point
            scale = gsf__atan_ratio(sqrt(r2));
            const double t2 = r2 * scale * scale;
            scale *= 1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * (k[3] + t2 * (k[4] + t2 * k[5])))));
            const double a = x * scale, b = y * scale, q = a * a + b * b;
            *u = a + 2.0 * k[7] * a * b + k[6] * (q + 2.0 * a * a) + q * (k[8] + q * k[9]);
            *v = b + 2.0 * k[6] * a * b + k[7] * (q + 2.0 * b * b) + q * (k[10] + q * k[11]);
            return;
        }
        case GSF__LENS_DIVISION: scale = 2.0 / (1.0 + sqrt(1.0 - 4.0 * k[0] * r2)); break;
        case GSF__LENS_EUCM: scale = 1.0 / (1.0 - k[0] + k[0] * sqrt(1.0 + k[1] * r2)); break;
    }
    *u = x * scale;
    *v = y * scale;
}

typedef struct gsf__rectify { // how a photo is resampled to a pinhole image
    gsf__lens lens;       // of the photo
    double fx, fy, cx, cy;// of the pinhole image
    int32_t width, height;// of the pinhole image
    double centre;        // where both images' intrinsics place the centre of the first pixel: 0 or 0.5
} gsf__rectify;

// Undistorts a pixel of a RATIONAL lens with the five fixed-point iterations of cv::undistortPoints. Not iterated to
// convergence, so that gsf__rectify_like_opencv finds the same rectangle, and hence the same camera, as OpenCV.
static void gsf__undistort_point(const gsf__lens* lens, double px, double py, double* x_out, double* y_out) {
    const double* k = lens->k;
    const double x0 = (px - lens->cx) / lens->fx, y0 = (py - lens->cy) / lens->fy;
    double x = x0, y = y0;
    for (int i = 0; i < 5; i++) {
        const double r2 = x * x + y * y;
        const double inverse =
            (1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))) / (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4])));
        if (inverse < 0.0) {
            x = x0;
            y = y0;
            break;
        }
        const double dx = 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x);
        const double dy = k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y;
        x = (x0 - dx) * inverse;
        y = (y0 - dy) * inverse;
    }
    *x_out = x;
    *y_out = y;
}

// Maps pixel (i, j) of the pinhole image to its position in the photo, in pixels (0 = centre of the first pixel).
static void gsf__rectify_map(const gsf__rectify* r, double i, double j, double* sx, double* sy) {
    double u, v;
    gsf__lens_distort(&r->lens, (i + r->centre - r->cx) / r->fx, (j + r->centre - r->cy) / r->fy, &u, &v);
    *sx = r->lens.fx * u + r->lens.cx - r->centre;
    *sy = r->lens.fy * v + r->lens.cy - r->centre;
}

// Returns whether the border of the pinhole image maps into the photo, or at most 5 % of the photo's size outside it.
static int gsf__rectify_is_sound(const gsf__rectify* r) {
    const int samples = 32;
    const double w = r->lens.width, h = r->lens.height;
    for (int side = 0; side < 4; side++)
        for (int i = 0; i <= samples; i++) {
            const double along = (double)i / samples, across = side & 1 ? 1.0 : 0.0;
            double x, y;
            gsf__rectify_map(r, (side < 2 ? along : across) * (r->width - 1),
                             (side < 2 ? across : along) * (r->height - 1), &x, &y);
            if (!(x > -0.05 * w - 1 && x < 1.05 * w && y > -0.05 * h - 1 && y < 1.05 * h)) return 0;
        }
    return 1;
}

// cv::getOptimalNewCameraMatrix(alpha = 0): the rectangle inscribed in the undistorted 9x9 grid fills the image. The
// region of interest that OpenCV returns is then always (0, 0, width - 1, height - 1). OpenCV puts pixel centres at 0,
// 1, ..., but the COLMAP parser of the GSFixer release passes it COLMAP's intrinsics, which assume 0.5, 1.5, ...; this
// function does the same (it shifts both images alike by a few hundredths of a pixel). Returns 0 when no image is left.
static int gsf__rectify_like_opencv(gsf__rectify* r) {
    const gsf__lens* lens = &r->lens;
    double x0 = -DBL_MAX, x1 = DBL_MAX, y0 = -DBL_MAX, y1 = DBL_MAX;
    if (lens->width < 2 || lens->height < 2) return 0;
    for (int j = 0; j < 9; j++)
        for (int i = 0; i < 9; i++) {
            double x, y;
            gsf__undistort_point(lens, (double)i * (lens->width - 1) / 8.0, (double)j * (lens->height - 1) / 8.0, &x,
                                 &y);
            if (!isfinite(x) || !isfinite(y)) return 0;
            if (i == 0) x0 = fmax(x0, x);
            if (i == 8) x1 = fmin(x1, x);
            if (j == 0) y0 = fmax(y0, y);
            if (j == 8) y1 = fmin(y1, y);
        }
    if (!(x1 - x0 > 1e-6 && y1 - y0 > 1e-6 && x1 - x0 < 1e3 && y1 - y0 < 1e3)) return 0;
    r->fx = (lens->width - 1) / (x1 - x0);
    r->fy = (lens->height - 1) / (y1 - y0);
    r->cx = -r->fx * x0;
    r->cy = -r->fy * y0;
    r->width = lens->width - 1;
    r->height = lens->height - 1;
    r->centre = 0.0;
    return gsf__rectify_is_sound(r);
}

// Returns whether the border of the pinhole image lies inside the photo, and inside radius_max, when its focal lengths
// are `zoom` times those of the lens.
static int gsf__rectify_fits(const gsf__rectify* r, double zoom, double radius_max) {
    const gsf__lens* lens = &r->lens;
    const int samples = 32;
    for (int side = 0; side < 4; side++)
        for (int i = 0; i <= samples; i++) {
            const double along = (double)i / samples, across = side & 1 ? 1.0 : 0.0;
            const double px = 0.5 + (side < 2 ? along : across) * (lens->width - 1);
            const double py = 0.5 + (side < 2 ? across : along) * (lens->height - 1);
            const double x = (px - lens->cx) / (zoom * lens->fx), y = (py - lens->cy) / (zoom * lens->fy);
            double u, v;
            if (!(x * x + y * y < radius_max * radius_max)) return 0;
            gsf__lens_distort(lens, x, y, &u, &v);
            u = lens->fx * u + lens->cx;
            v = lens->fy * v + lens->cy;
            if (!(u >= 0.5 && v >= 0.5 && u <= lens->width - 0.5 && v <= lens->height - 0.5)) return 0;
        }
    return 1;
}

// Returns the tangent of the largest angle to the optical axis that a pinhole image may show: at most 75 degrees, and
// less where the lens's distortion polynomial stops increasing.
static double gsf__lens_radius_max(const gsf__lens* lens) {
    static const double directions[8][2] = {{1, 0},  {0.6, 0.8},   {0, 1},  {-0.8, 0.6},
                                            {-1, 0}, {-0.6, -0.8}, {0, -1}, {0.8, -0.6}};
    double limit = 3.7320508075688772;
    for (int d = 0; d < 8; d++) {
        double last = 0.0;
        for (int i = 1; i <= 64; i++) {
            const double r = 3.7320508075688772 * i / 64;
            double u, v;
            gsf__lens_distort(lens, directions[d][0] * r, directions[d][1] * r, &u, &v);
            const double distance = u * u + v * v;
            if (!(distance > last)) {
                limit = fmin(limit, 3.7320508075688772 * (i - 1) / 64);
                break;
            }
            last = distance;
        }
    }
    return limit;
}

// Makes the pinhole image as large as the photo, with the photo's principal point and `zoom` times its focal lengths.
static void gsf__rectify_zoomed(gsf__rectify* r, double zoom) {
    r->fx = r->lens.fx * zoom;
    r->fy = r->lens.fy * zoom;
    r->cx = r->lens.cx;
    r->cy = r->lens.cy;
    r->width = r->lens.width;
    r->height = r->lens.height;
    r->centre = 0.5;
}

// Rectifies the lenses that the parser of the GSFixer release has no sound method for (all but RATIONAL), and those for
// which OpenCV's rectangle fails. Size, principal point and pixel aspect are those of the photo; the zoom is the
// smallest at which no pixel falls outside the photo. Pixel centres are exact. Returns 0 when no image is left.
static int gsf__rectify_by_zoom(gsf__rectify* r) {
    const double radius_max = gsf__lens_radius_max(&r->lens);
    double low = 1.0 / 1024, high = 64.0;
    if (!gsf__rectify_fits(r, high, radius_max)) return 0;
    for (int i = 0; i < 40 && high - low > 1e-7 * high; i++) {
        const double middle = sqrt(low * high);
        if (gsf__rectify_fits(r, middle, radius_max)) high = middle;
        else low = middle;
    }
    gsf__rectify_zoomed(r, high);
    return 1;
}

// Chooses the pinhole camera for a lens. Returns 0 when its distortion leaves no usable image.
static int gsf__rectify_make(const gsf__lens* lens, gsf__rectify* r) {
    memset(r, 0, sizeof *r);
    r->lens = *lens;
    if (lens->kind == GSF__LENS_FOV) {
        const double omega = fabs(lens->k[0]);
        r->lens.k[1] = omega < 1e-6 ? 1.0 : 2.0 * gsf__tan_f64(0.5 * omega);
        r->lens.k[2] = omega < 1e-6 ? 1.0 : r->lens.k[1] / omega;
        if (omega < 1e-6) r->lens.kind = GSF__LENS_PINHOLE;
    }
    gsf__rectify_zoomed(r, 1.0);
    if (r->lens.kind == GSF__LENS_PINHOLE) return 1;
    if (r->lens.kind == GSF__LENS_RATIONAL && gsf__rectify_like_opencv(r)) return 1;
    return gsf__rectify_by_zoom(r);
}

typedef struct gsf__rectify_job {
    const gsf__rectify* r;
    const uint8_t* src; // photo: packed u8
    uint8_t* dst;       // pinhole image: packed u8
    int32_t channels;
} gsf__rectify_job;

enum { GSF__RECTIFY_ROWS = 16 };

// One bilinear sample per pixel. Positions are rounded to 1/32 pixel as in cv::remap, so weights are multiples of
// 1/1024; positions outside the photo are clamped to its border.
static void gsf__rectify_rows(void* arg, size_t chunk, int32_t worker) {
    const gsf__rectify_job* job = (const gsf__rectify_job*)arg;
    const gsf__rectify* r = job->r;
    const int32_t w = r->lens.width, h = r->lens.height, channels = job->channels;
    const int32_t first = (int32_t)chunk * GSF__RECTIFY_ROWS;
    const int32_t last = first + GSF__RECTIFY_ROWS < r->height ? first + GSF__RECTIFY_ROWS : r->height;
    (void)worker;
    for (int32_t j = first; j < last; j++)
        for (int32_t i = 0; i < r->width; i++) {
            double sx, sy;
            gsf__rectify_map(r, i, j, &sx, &sy);
            sx = sx > 0.0 ? (sx < w - 1 ? sx : w - 1) : 0.0; // NaN becomes 0
            sy = sy > 0.0 ? (sy < h - 1 ? sy : h - 1) : 0.0;
            const int64_t tx = (int64_t)(sx * 32.0 + 0.5), ty = (int64_t)(sy * 32.0 + 0.5);
            const uint32_t ax = (uint32_t)(tx & 31), ay = (uint32_t)(ty & 31);
            const int64_t x0 = tx >> 5, y0 = ty >> 5;
            const int64_t x1 = x0 + 1 < w ? x0 + 1 : w - 1, y1 = y0 + 1 < h ? y0 + 1 : h - 1;
            const uint8_t *row0 = job->src + channels * y0 * w, *row1 = job->src + channels * y1 * w;
            uint8_t* out = job->dst + channels * ((int64_t)j * r->width + i);
            for (int32_t c = 0; c < channels; c++) {
                const uint32_t top = row0[channels * x0 + c] * (32 - ax) + row0[channels * x1 + c] * ax;
                const uint32_t bottom = row1[channels * x0 + c] * (32 - ax) + row1[channels * x1 + c] * ax;
                out[c] = (uint8_t)((top * (32 - ay) + bottom * ay + 512) >> 10);
            }
        }
}

// photo: packed u8, of the size in r->lens. out: new image of r->width x r->height pixels.
static gsf_result gsf__rectify_image(gsf_context* ctx, const gsf__rectify* r, const gsf_image* photo, gsf_image* out) {
    GSF__TRY(gsf_make_image(ctx, GSF_U8, r->width, r->height, photo->channels, out));
    gsf__rectify_job job;
    job.r = r;
    job.src = (const uint8_t*)photo->data;
    job.dst = (uint8_t*)out->data;
    job.channels = photo->channels;
    gsf__parallel_for(ctx, ((size_t)r->height + GSF__RECTIFY_ROWS - 1) / GSF__RECTIFY_ROWS, gsf__rectify_rows, &job);
    return GSF_OK;
}

// ---- >>scene -------------------------------------------------------------------

typedef struct gsf__view_source { // a view's photo, for gsf_splat_load_view_image
    gsf__rectify rectify;    // lens: scaled to the size at which the photo is undistorted
    size_t path, mask;       // offsets into paths; mask: path without .png; SIZE_MAX: scene parsed from memory
    int64_t file_width, file_height;
} gsf__view_source;

typedef struct gsf__scene_state {
    gsf__view_source* sources; // one per view
    char* names;               // storage of the views' names
    gsf_buffer paths;          // paths of photos and masks, NUL-terminated
    int32_t no_masks;
} gsf__scene_state;

GSF_API void gsf_splat_destroy_scene(gsf_context* ctx, gsf_scene* scene) {
    gsf__scene_state* state = (gsf__scene_state*)scene->state;
    for (size_t i = 0; i < scene->view_count; i++) {
        gsf_destroy_image(ctx, &scene->views[i].image);
        gsf_destroy_image(ctx, &scene->views[i].weight);
    }
    if (state) {
        gsf_free(ctx, state->sources);
        gsf_free(ctx, state->names);
        gsf_destroy_buffer(ctx, &state->paths);
        gsf_free(ctx, state);
    }
    gsf_free(ctx, scene->views);
    gsf_free(ctx, scene->points);
    gsf_free(ctx, scene->colors);
    gsf_free(ctx, scene->point_ids);
    gsf_free(ctx, scene->track_begin);
    gsf_free(ctx, scene->track_views);
    gsf_free(ctx, scene->folder);
    memset(scene, 0, sizeof *scene);
}

// ---- files ----

// Suspends the log hook while something runs that is allowed to fail, and saves ctx->error to restore it afterwards.
typedef struct gsf__hush {
    gsf_logger logger;
    char error[512];
} gsf__hush;

static void gsf__hush_begin(gsf_context* ctx, gsf__hush* hush) {
    hush->logger = ctx->logger;
    memcpy(hush->error, ctx->error, sizeof hush->error);
    memset(&ctx->logger, 0, sizeof ctx->logger);
}

// Restores the log hook. Returns the result of what was run: a missing file sets *absent and is GSF_OK, another error is
// logged now, and without one ctx->error is restored.
static gsf_result gsf__hush_end(gsf_context* ctx, const gsf__hush* hush, gsf_result result, int* absent) {
    ctx->logger = hush->logger;
    *absent = result == GSF_ERROR_NOT_FOUND;
    if (*absent) result = GSF_OK;
    if (result == GSF_OK) memcpy(ctx->error, hush->error, sizeof hush->error);
    else gsf_log(ctx, GSF_LOG_ERROR, "%s", ctx->error);
    return result;
}

// Reads <folder><relative>. *data is NULL if the file does not exist.
static gsf_result gsf__read_if_there(gsf_context* ctx, const char* folder, const char* relative, gsf_buffer* path,
                                     void** data, size_t* size) {
    gsf__hush hush;
    int absent;
    path->size = 0;
    gsf_append_text(ctx, path, "%s%s", folder, relative);
    if (path->failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__hush_begin(ctx, &hush);
    return gsf__hush_end(ctx, &hush, gsf_read_file(ctx, path->data, data, size), &absent);
}

// Names come from untrusted files, so they must not lead out of the folder: relative, no "..", no drive letter.
static gsf_result gsf__check_relative(gsf_context* ctx, const char* where, size_t at, const char* name, size_t size) {
    int bad = size == 0 || name[0] == '/' || name[0] == '\\';
    bad = bad || (size >= 2 && name[1] == ':' && ((name[0] | 32) >= 'a' && (name[0] | 32) <= 'z'));
    for (size_t i = 0, start = 0; i <= size && !bad; i++) {
        if (i < size && name[i] == 0) bad = 1;
        if (i < size && name[i] != '/' && name[i] != '\\') continue;
        bad = bad || (i - start == 2 && name[start] == '.' && name[start + 1] == '.');
        start = i + 1;
    }
    if (!bad) return GSF_OK;
    return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: the file name \"%.*s\" leads out of its folder", where, at,
                    (int)(size < 100 ? size : 100), name);
}

typedef struct gsf__photos { // location of a model's photos; a NULL pointer to it means parsed from memory, no photos
    const char* folder;   // ends with a separator, or is empty
    const char* prefix;   // "images/" (COLMAP) or "" (transforms.json, whose paths include the folder)
    int32_t factor, max_size, no_masks;
} gsf__photos;

// Returns the size of the image at `path`; *width is 0 if there is none.
static gsf_result gsf__query_photo(gsf_context* ctx, const gsf_buffer* path, int64_t* width, int64_t* height) {
    gsf__hush hush;
    int32_t channels;
    int absent;
    if (path->failed) return GSF_ERROR_OUT_OF_MEMORY;
    gsf__hush_begin(ctx, &hush);
    const gsf_result result =
        gsf__hush_end(ctx, &hush, gsf_query_image(ctx, path->data, width, height, &channels), &absent);
    if (absent) *width = *height = 0;
    return result;
}

// Finds a view's photo. With a factor, looks first in <first folder>_<factor>/, under the same name or with another
// extension (downscaled copies of .jpg files are often .png); then for the full-size photo. transforms.json may omit
// the extension. *reduced is set if the downscaled copy was found; *width is 0 if nothing was.
static gsf_result gsf__find_photo(gsf_context* ctx, const gsf__photos* photos, const char* name, gsf_buffer* path,
                                  int64_t* width, int64_t* height, int* reduced) {
    static const char* const extensions[6] = {".png", ".jpg", ".JPG", ".jpeg", ".PNG", ".JPEG"};
    const int count = (int)GSF__COUNT(extensions);
    *reduced = 1;
    const char* first = photos->prefix[0] ? photos->prefix : name;
    const char* slash = strchr(first, '/');
    const char* dot = strrchr(name, '.');
    if (dot && strchr(dot, '/')) dot = NULL;
    if (photos->factor > 1 && slash) {
        const char* rest = photos->prefix[0] ? name : slash + 1;
        for (int i = -1; i < count; i++) {
            const size_t kept = i < 0 || !dot ? strlen(rest) : (size_t)(dot - rest);
            path->size = 0;
            gsf_append_text(ctx, path, "%s%.*s_%d/%.*s%s", photos->folder, (int)(slash - first), first,
                            (int)photos->factor, (int)kept, rest, i < 0 ? "" : extensions[i]);
            GSF__TRY(gsf__query_photo(ctx, path, width, height));
            if (*width) return GSF_OK;
        }
    }
    *reduced = 0;
    for (int i = -1; i < (photos->prefix[0] || dot ? 0 : count); i++) {
        path->size = 0;
        gsf_append_text(ctx, path, "%s%s%s%s", photos->folder, photos->prefix, name, i < 0 ? "" : extensions[i]);
        GSF__TRY(gsf__query_photo(ctx, path, width, height));
        if (*width) return GSF_OK;
    }
    return GSF_OK;
}

// ---- from model to scene ----

static double gsf__round_half_even(double x) { // as Python's and numpy's round; for x >= 0 well below 2^52
    const double down = floor(x), rest = x - down;
    if (rest != 0.5) return rest < 0.5 ? down : down + 1.0;
    return fmod(down, 2.0) == 0.0 ? down : down + 1.0;
}

static int gsf__compare_image_names(const void* a, const void* b) {
    const gsf__sfm_image *x = (const gsf__sfm_image*)a, *y = (const gsf__sfm_image*)b;
    const size_t shorter = x->name_size < y->name_size ? x->name_size : y->name_size;
    const int order = memcmp(x->name, y->name, shorter);
    if (order) return order;
    return (x->name_size > y->name_size) - (x->name_size < y->name_size);
}

// Completes the lens of a camera: takes what transforms.json omits from the photo's size (width 0: no photo). Returns 0
// if the size or focal length cannot be determined.
static int gsf__camera_lens(const gsf__sfm_camera* camera, int64_t width, int64_t height, gsf__lens* out) {
    *out = camera->lens;
    if (!camera->open) return 1;
    if (out->width == 0) {
        if (width == 0) return 0;
        out->width = (int32_t)width;
        out->height = (int32_t)height;
    }
    if (!(out->fx > 0.0)) out->fx = 0.5 * out->width / gsf__tan_f64(0.5 * camera->angle_x);
    if (!(out->fy > 0.0)) out->fy = camera->angle_y > 0.0 ? 0.5 * out->height / gsf__tan_f64(0.5 * camera->angle_y) : out->fx;
    if (isnan(out->cx)) out->cx = 0.5 * out->width;
    if (isnan(out->cy)) out->cy = 0.5 * out->height;
    return isfinite(out->fx) && isfinite(out->fy) && out->fx > 0.0 && out->fy > 0.0;
}

// Computes the size to which a photo is scaled.
static void gsf__target_size(const gsf__photos* photos, int64_t width, int64_t height, int reduced, int32_t* out_width,
                             int32_t* out_height) {
    double scale = 1.0;
    const int64_t longer = width > height ? width : height;
    if (photos->factor > 1 && !reduced) scale = 1.0 / photos->factor;
    if (photos->max_size > 0 && longer > photos->max_size) scale = (double)photos->max_size / (double)longer;
    *out_width = (int32_t)fmax(1.0, gsf__round_half_even((double)width * scale));
    *out_height = (int32_t)fmax(1.0, gsf__round_half_even((double)height * scale));
}

// Fills *view and *source from an image of the model. *present = 0 if its photo is missing.
// The parser of the GSFixer release divides K by the factor and multiplies it by actual / (COLMAP size / factor,
// rounded down). Here nothing is rounded, so K is simply scaled by the ratio of the sizes, per axis and view.
static gsf_result gsf__scene_make_view(gsf_context* ctx, const gsf__sfm* m, const gsf__sfm_image* image,
                                       const gsf__photos* photos, gsf_buffer* path, gsf_scene_view* view,
                                       gsf__view_source* source, int* present) {
    int64_t width = 0, height = 0;
    int reduced = 0;
    gsf__lens lens;
    if (photos) GSF__TRY(gsf__find_photo(ctx, photos, view->name, path, &width, &height, &reduced));
    *present = !photos || width > 0;
    if (!*present) return GSF_OK;
    if (width > GSF__LENS_SIZE_MAX || height > GSF__LENS_SIZE_MAX)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: image size %lld x %lld", path->data, (long long)width,
                        (long long)height);
    const int64_t full = reduced ? photos->factor : 1; // an omitted size is that of the full-size photo
    if (!gsf__camera_lens(&m->cameras[image->camera], width * full, height * full, &lens))
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: \"%s\": no usable w, h or focal length", m->images_name,
                        image->at, view->name);
    if (photos) {
        int32_t w, h;
        gsf__target_size(photos, width, height, reduced, &w, &h);
        const double sx = (double)w / lens.width, sy = (double)h / lens.height;
        lens.fx *= sx;
        lens.cx *= sx;
        lens.fy *= sy;
        lens.cy *= sy;
        lens.width = w;
        lens.height = h;
    }
    if (!gsf__rectify_make(&lens, &source->rectify))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "%s:%zu: \"%s\": the distortion of camera %u leaves no image",
                        m->images_name, image->at, view->name, (unsigned)image->camera_id);
    source->file_width = width;
    source->file_height = height;
    gsf_camera* camera = &view->camera;
    memcpy(camera->w2c, image->w2c, sizeof camera->w2c);
    camera->fx = source->rectify.fx;
    camera->fy = source->rectify.fy;
    camera->cx = source->rectify.cx;
    camera->cy = source->rectify.cy;
    camera->width = source->rectify.width;
    camera->height = source->rectify.height;
    view->image_id = image->id;
    return gsf_check_camera(ctx, camera);
}

// Makes names, views and sources of all images whose photo exists, sorted by name. Also sorts m->images and overwrites
// their `camera` with the index of the view (UINT32_MAX: omitted).
static gsf_result gsf__scene_make_views(gsf_context* ctx, gsf__sfm* m, const gsf__photos* photos, gsf_scene* scene) {
    gsf__scene_state* state = (gsf__scene_state*)scene->state;
    gsf_buffer path;
    gsf_result result = GSF_OK;
    size_t name_bytes = 0, missing = 0;
    memset(&path, 0, sizeof path);
    if (m->image_count == 0) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no image in the file", m->images_name);
    if (m->image_count >= UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: %zu images", m->images_name, m->image_count);
    qsort(m->images, m->image_count, sizeof *m->images, gsf__compare_image_names);
    for (size_t i = 0; i < m->image_count; i++) {
        const gsf__sfm_image* image = &m->images[i];
        GSF__TRY(gsf__check_relative(ctx, m->images_name, image->at, image->name, image->name_size));
        if (i && gsf__compare_image_names(image, image - 1) == 0)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: two images are named \"%.*s\"", m->images_name, image->at,
                            (int)(image->name_size < 100 ? image->name_size : 100), image->name);
        name_bytes += image->name_size + 1;
    }
    scene->views = (gsf_scene_view*)gsf_alloc_zeroed(ctx, m->image_count, sizeof *scene->views);
    state->sources = (gsf__view_source*)gsf_alloc_zeroed(ctx, m->image_count, sizeof *state->sources);
    state->names = (char*)gsf_alloc(ctx, name_bytes, 1);
    if (!scene->views || !state->sources || !state->names) return GSF_ERROR_OUT_OF_MEMORY;
    char* names = state->names;
    for (size_t i = 0; i < m->image_count && result == GSF_OK; i++) {
        gsf__sfm_image* image = &m->images[i];
        gsf_scene_view* view = &scene->views[scene->view_count];
        gsf__view_source* source = &state->sources[scene->view_count];
        int present = 0;
        view->name = names;
        memcpy(names, image->name, image->name_size);
        names[image->name_size] = 0;
        names += image->name_size + 1;
        result = gsf__scene_make_view(ctx, m, image, photos, &path, view, source, &present);
        if (result == GSF_OK && !present) {
            if (!missing++) gsf_log(ctx, GSF_LOG_WARNING, "%s%s%s: no such photo; the view is omitted", photos->folder,
                                    photos->prefix, view->name);
            memset(view, 0, sizeof *view);
        }
        image->camera = present ? scene->view_count : UINT32_MAX;
        source->path = source->mask = SIZE_MAX;
        if (result == GSF_OK && present && photos) {
            const char* slash = photos->prefix[0] ? NULL : strchr(view->name, '/');
            source->path = state->paths.size;
            gsf_append_bytes(ctx, &state->paths, path.data, path.size + 1);
            source->mask = state->paths.size; // masks/ replaces the photos' top folder
            gsf_append_text(ctx, &state->paths, "%smasks/%s", photos->folder, slash ? slash + 1 : view->name);
            gsf_append_bytes(ctx, &state->paths, "", 1);
            if (state->paths.failed) result = GSF_ERROR_OUT_OF_MEMORY;
        }
        if (result == GSF_OK && present) scene->view_count++;
    }
    scene->missing_count = missing;
    if (missing > 1)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu of %zu photos are missing", photos->folder, missing, m->image_count);
    if (result == GSF_OK && scene->view_count == 0)
        result = gsf_fail(ctx, GSF_ERROR_NOT_FOUND, "%s%s: all %zu photos are missing", photos->folder, photos->prefix,
                          m->image_count);
    gsf_destroy_buffer(ctx, &path);
    return result;
}

// Converts tracks from image ids to view indices, sorted and without duplicates. Ids of omitted images are dropped, as
// are ids that no image has, which are also counted in a warning. Sorts m->images by id.
static gsf_result gsf__scene_map_tracks(gsf_context* ctx, gsf__sfm* m) {
    qsort(m->images, m->image_count, sizeof *m->images, gsf__compare_ids);
    for (size_t i = 1; i < m->image_count; i++)
        if (m->images[i].id == m->images[i - 1].id)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: image id %u occurs twice", m->images_name, m->images[i].at,
                            (unsigned)m->images[i].id);
    gsf_scene* scene = m->scene;
    uint32_t* views = scene->track_views;
    if (scene->track_begin[scene->point_count] == 0) return GSF_OK;
    // Ids are usually dense, so they index a table; sparse ids use binary search.
    const uint32_t last = m->images[m->image_count - 1].id;
    uint32_t* table = NULL;
    size_t longest = 0;
    for (size_t p = 0; p < scene->point_count; p++) {
        const size_t length = scene->track_begin[p + 1] - scene->track_begin[p];
        longest = length > longest ? length : longest;
    }
    uint64_t* keys = (uint64_t*)gsf_alloc(ctx, longest, 2 * sizeof *keys); // of a point's views, and room to sort them
    if (!keys) return GSF_ERROR_OUT_OF_MEMORY;
    if (last / 8 <= m->image_count) {
        table = (uint32_t*)gsf_alloc(ctx, (size_t)last + 1, sizeof *table);
        if (!table) {
            gsf_free(ctx, keys);
            return GSF_ERROR_OUT_OF_MEMORY;
        }
        memset(table, 0xff, ((size_t)last + 1) * sizeof *table);
        for (size_t i = 0; i < m->image_count; i++) table[m->images[i].id] = (uint32_t)i;
    }
    size_t kept = 0, unknown = 0, begin = 0;
    for (size_t p = 0; p < scene->point_count; p++) {
        const size_t end = scene->track_begin[p + 1];
        size_t n = 0;
        for (size_t k = begin; k < end; k++) {
            const uint32_t id = views[k];
            const gsf__sfm_image* image;
            if (table) image = id <= last && table[id] != UINT32_MAX ? &m->images[table[id]] : NULL;
            else image = (const gsf__sfm_image*)bsearch(&id, m->images, m->image_count, sizeof *m->images,
                                                        gsf__compare_ids);
            unknown += image == NULL;
            if (image && image->camera != UINT32_MAX) keys[n++] = (uint64_t)image->camera << 32;
        }
        const uint64_t* sorted = gsf__sort_keys(keys, keys + longest, n);
        for (size_t k = 0; k < n; k++)
            if (k == 0 || sorted[k] != sorted[k - 1]) views[kept++] = (uint32_t)(sorted[k] >> 32);
        begin = end;
        scene->track_begin[p + 1] = kept;
    }
    gsf_free(ctx, keys);
    gsf_free(ctx, table);
    if (unknown)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu track entries name images that do not exist", m->images_name, unknown);
    return GSF_OK;
}

// Turns what has been read into a scene. photos: NULL if parsed from memory.
static gsf_result gsf__scene_build(gsf_context* ctx, gsf__sfm* m, const gsf__photos* photos) {
    gsf_scene* scene = m->scene;
    scene->state = gsf_alloc_zeroed(ctx, 1, sizeof(gsf__scene_state));
    if (!scene->state) return GSF_ERROR_OUT_OF_MEMORY;
    if (photos) ((gsf__scene_state*)scene->state)->no_masks = photos->no_masks;
    GSF__TRY(gsf__scene_make_views(ctx, m, photos, scene));
    GSF__TRY(gsf__scene_map_tracks(ctx, m));
    for (size_t i = 0; i < scene->view_count; i++) {
        double centre[3];
        gsf_get_camera_center(&scene->views[i].camera, centre);
        for (int k = 0; k < 3; k++) scene->origin[k] += centre[k] / (double)scene->view_count;
    }
    if (m->dropped_points)
        gsf_log(ctx, GSF_LOG_WARNING, "%s: %zu points dropped: a coordinate is NaN or infinite", m->images_name,
                m->dropped_points);
    return GSF_OK;
}

// Builds the scene if reading succeeded, else destroys it; frees the rest of the model. Returns the first error.
static gsf_result gsf__sfm_finish(gsf_context* ctx, gsf__sfm* m, const gsf__photos* photos, gsf_result result) {
    if (result == GSF_OK) result = gsf__scene_build(ctx, m, photos);
    if (result != GSF_OK) gsf_splat_destroy_scene(ctx, m->scene);
    gsf_free(ctx, m->cameras);
    gsf_free(ctx, m->images);
    return result;
}

// ---- public ----

GSF_API gsf_result gsf_splat_parse_colmap(gsf_context* ctx, int32_t is_text, const gsf_bytes* cameras,
                                          const gsf_bytes* images, const gsf_bytes* points, gsf_scene* out) {
    gsf__sfm m;
    gsf_result result = gsf__sfm_init(ctx, &m, out);
    if (result == GSF_OK) result = gsf__colmap_read(ctx, is_text, cameras, images, points, &m);
    return gsf__sfm_finish(ctx, &m, NULL, result);
}

// photos: NULL if parsed from memory; else photos->folder must end with a separator. path: scratch.
static gsf_result gsf__parse_transforms(gsf_context* ctx, const char* name, const void* data, size_t size,
                                        const gsf__photos* photos, gsf_buffer* path, gsf_scene* out) {
    gsf_json json;
    gsf__sfm m;
    void* points = NULL;
    size_t points_size = 0;
    GSF__TRY(gsf_parse_json(ctx, name, (const char*)data, size, &json));
    gsf_result result = gsf__sfm_init(ctx, &m, out);
    if (result == GSF_OK) result = gsf__transforms_read(ctx, &json, &m);
    const gsf_json_value* ply = photos ? gsf_find_json_member(&json, &json.values[0], "ply_file_path") : NULL;
    if (result == GSF_OK && ply && ply->type == GSF_JSON_STRING) {
        result = gsf__check_relative(ctx, name, ply->offset, ply->string, ply->string_size);
        path->size = 0;
        gsf_append_text(ctx, path, "%s%s", photos->folder, ply->string);
        if (result == GSF_OK && path->failed) result = GSF_ERROR_OUT_OF_MEMORY;
        if (result == GSF_OK) result = gsf_read_file(ctx, path->data, &points, &points_size);
        if (result == GSF_OK) result = gsf__transforms_read_points(ctx, path->data, points, points_size, &m);
    }
    result = gsf__sfm_finish(ctx, &m, photos, result);
    gsf_free(ctx, points);
    gsf_destroy_json(ctx, &json);
    return result;
}

GSF_API gsf_result gsf_splat_parse_transforms(gsf_context* ctx, const gsf_bytes* json, gsf_scene* out) {
    memset(out, 0, sizeof *out);
    return gsf__parse_transforms(ctx, json->name ? json->name : "transforms.json", json->data ? json->data : "",
                                 json->data ? json->size : 0, NULL, NULL, out);
}

// Reads the three files of the first model found. *found is 0 if there is none.
static gsf_result gsf__load_colmap(gsf_context* ctx, const gsf__photos* photos, gsf_buffer* path, int* found,
                                   gsf_scene* out) {
    static const char* const folders[3] = {"sparse/0/", "sparse/", ""};
    static const char* const files[3] = {"cameras", "images", "points3D"};
    gsf_bytes bytes[3];
    void* data[3] = {NULL, NULL, NULL};
    gsf_buffer names[3];
    gsf__sfm m;
    gsf_result result = GSF_OK;
    memset(bytes, 0, sizeof bytes);
    memset(names, 0, sizeof names);
    *found = 0;
    for (int i = 0; i < 6 && !*found && result == GSF_OK; i++) { // in each folder, binary before text
        const char* extension = i & 1 ? ".txt" : ".bin";
        char relative[32];
        snprintf(relative, sizeof relative, "%scameras%s", folders[i / 2], extension);
        result = gsf__read_if_there(ctx, photos->folder, relative, path, &data[0], &bytes[0].size);
        if (result != GSF_OK || !data[0]) continue;
        *found = 1;
        result = gsf__sfm_init(ctx, &m, out);
        for (int k = 0; k < 3 && result == GSF_OK; k++) {
            gsf_append_text(ctx, &names[k], "%s%s%s%s", photos->folder, folders[i / 2], files[k], extension);
            if (names[k].failed) result = GSF_ERROR_OUT_OF_MEMORY;
            else if (k > 0) result = gsf_read_file(ctx, names[k].data, &data[k], &bytes[k].size);
            bytes[k].data = data[k];
            bytes[k].name = names[k].data;
        }
        if (result == GSF_OK) result = gsf__colmap_read(ctx, i & 1, &bytes[0], &bytes[1], &bytes[2], &m);
        result = gsf__sfm_finish(ctx, &m, photos, result);
    }
    for (int k = 0; k < 3; k++) {
        gsf_free(ctx, data[k]);
        gsf_destroy_buffer(ctx, &names[k]);
    }
    return result;
}

static gsf_result gsf__load_scene_at(gsf_context* ctx, const char* path, gsf__photos* photos, gsf_buffer* folder,
                                     gsf_buffer* scratch, void** json, gsf_scene* out) {
    const size_t length = strlen(path);
    const int is_file = length >= 5 && strcmp(path + length - 5, ".json") == 0;
    size_t size = 0, folder_size = length;
    int found = 0;
    if (is_file) {
        while (folder_size && path[folder_size - 1] != '/' && path[folder_size - 1] != '\\') folder_size--;
        gsf_append_bytes(ctx, folder, path, folder_size);
    } else {
        const int closed = length == 0 || path[length - 1] == '/' || path[length - 1] == '\\';
        gsf_append_text(ctx, folder, "%s%s", path, closed ? "" : "/");
    }
    if (folder->failed) return GSF_ERROR_OUT_OF_MEMORY;
    photos->folder = folder->data;
    if (!is_file) {
        photos->prefix = "images/";
        GSF__TRY(gsf__load_colmap(ctx, photos, scratch, &found, out));
        if (found) return GSF_OK;
        GSF__TRY(gsf__read_if_there(ctx, folder->data, "transforms.json", scratch, json, &size));
        if (!*json)
            return gsf_fail(ctx, GSF_ERROR_NOT_FOUND,
                            "%s: no scene: neither sparse/0/cameras.bin or .txt nor transforms.json", path);
        path = "transforms.json";
    } else {
        GSF__TRY(gsf_read_file(ctx, path, json, &size));
    }
    photos->prefix = "";
    return gsf__parse_transforms(ctx, path, *json, size, photos, scratch, out);
}

GSF_API gsf_result gsf_splat_load_scene(gsf_context* ctx, const char* path, const gsf_scene_desc* desc,
                                        gsf_scene* out) {
    gsf__photos photos;
    gsf_buffer folder, scratch;
    void* json = NULL;
    memset(&photos, 0, sizeof photos);
    memset(&folder, 0, sizeof folder);
    memset(&scratch, 0, sizeof scratch);
    memset(out, 0, sizeof *out);
    photos.factor = desc && desc->factor ? desc->factor : 1;
    photos.max_size = desc ? desc->max_size : 0;
    photos.no_masks = desc ? desc->no_masks : 0;
    if (photos.factor < 1 || photos.max_size < 0 || (photos.factor > 1 && photos.max_size > 0))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "scene: factor %d, max_size %d (not negative, not both)",
                        (int)photos.factor, (int)photos.max_size);
    gsf_result result = gsf__load_scene_at(ctx, path, &photos, &folder, &scratch, &json, out);
    if (result == GSF_OK) {
        out->folder = (char*)gsf_alloc(ctx, strlen(path) + 1, 1);
        if (out->folder) memcpy(out->folder, path, strlen(path) + 1);
        else result = GSF_ERROR_OUT_OF_MEMORY;
    }
    if (result != GSF_OK) gsf_splat_destroy_scene(ctx, out);
    gsf_free(ctx, json);
    gsf_destroy_buffer(ctx, &folder);
    gsf_destroy_buffer(ctx, &scratch);
    return result;
}

// ---- photos and their masks ----

static gsf_image gsf__channels_of(const gsf_image* image, int32_t first, int32_t count) {
    gsf_image view = *image;
    view.data = (char*)image->data + first * image->stride_c;
    view.channels = count;
    view.owned = NULL;
    return view;
}

// Makes a view's pixel weights, alpha times mask, at the photo's size. Either may be missing; out->data is NULL if all
// pixels have full weight.
static gsf_result gsf__view_weight(gsf_context* ctx, const gsf_image* photo, const gsf_image* mask, gsf_image* out) {
    memset(out, 0, sizeof *out);
    const int has_alpha = photo->channels == 2 || photo->channels == 4;
    if (!has_alpha && !mask) return GSF_OK;
    GSF__TRY(gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 1, out));
    uint8_t* w = (uint8_t*)out->data;
    const size_t pixels = (size_t)photo->width * (size_t)photo->height;
    gsf_result result = GSF_OK;
    if (has_alpha) {
        gsf_image alpha = gsf__channels_of(photo, photo->channels - 1, 1);
        alpha.color_space = GSF_COLOR_SRGB; // not a color: no conversion
        result = gsf_convert_image(ctx, &alpha, out);
    } else {
        memset(w, 255, pixels);
    }
    for (size_t i = 0; result == GSF_OK && mask && i < pixels; i++)
        w[i] = (uint8_t)((w[i] * ((const uint8_t*)mask->data)[i] + 127) / 255);
    size_t full = 0;
    while (full < pixels && w[full] == 255) full++;
    if (result != GSF_OK || full == pixels) gsf_destroy_image(ctx, out);
    return result;
}

// Premultiplies colours by weights, in one image of four channels, so that resampling mixes neighbours in proportion to
// their weights.
static gsf_result gsf__join_weight(gsf_context* ctx, const gsf_image* rgb, const gsf_image* weight, gsf_image* out) {
    GSF__TRY(gsf_make_image(ctx, GSF_F32, rgb->width, rgb->height, 4, out));
    const uint8_t *c = (const uint8_t*)rgb->data, *w = (const uint8_t*)weight->data;
    float* to = (float*)out->data;
    for (size_t i = 0; i < (size_t)rgb->width * (size_t)rgb->height; i++) {
        for (size_t k = 0; k < 3; k++) to[4 * i + k] = (float)(c[3 * i + k] * w[i]) / 255.0f;
        to[4 * i + 3] = (float)w[i];
    }
    return GSF_OK;
}

// Converts to bytes. Bicubic filters overshoot: where a weight is clamped to 255, its premultiplied colours are scaled
// with it.
static gsf_result gsf__joint_bytes(gsf_context* ctx, gsf_image* joint) {
    gsf_image bytes;
    GSF__TRY(gsf_make_image(ctx, GSF_U8, joint->width, joint->height, 4, &bytes));
    const float* from = (const float*)joint->data;
    for (size_t i = 0; i < 4 * (size_t)joint->width * (size_t)joint->height; i += 4)
        for (size_t k = 0; k < 4; k++)
            ((uint8_t*)bytes.data)[i + k] =
                gsf__to_u8(from[i + 3] > 255.0f ? from[i + k] * (255.0f / from[i + 3]) : from[i + k]);
    gsf_destroy_image(ctx, joint);
    *joint = bytes;
    return GSF_OK;
}

static gsf_result gsf__part_weight(gsf_context* ctx, const gsf_image* joint, gsf_image* rgb, gsf_image* weight) {
    GSF__TRY(gsf_make_image(ctx, GSF_U8, joint->width, joint->height, 3, rgb));
    GSF__TRY(gsf_make_image(ctx, GSF_U8, joint->width, joint->height, 1, weight));
    const uint8_t* from = (const uint8_t*)joint->data;
    for (size_t i = 0; i < (size_t)joint->width * (size_t)joint->height; i++) {
        const uint8_t w = from[4 * i + 3];
        for (size_t k = 0; k < 3 && w > 0; k++)
            ((uint8_t*)rgb->data)[3 * i + k] = gsf__to_u8(255.0f * from[4 * i + k] / w);
        ((uint8_t*)weight->data)[i] = w;
    }
    return GSF_OK;
}

// Resizes a photo to the size for which the camera was scaled.
static gsf_result gsf__size_photo(gsf_context* ctx, const gsf__rectify* r, gsf_image* image) {
    gsf_image sized;
    if (image->width == r->lens.width && image->height == r->lens.height) return GSF_OK;
    GSF__TRY(gsf_make_image(ctx, image->dtype, r->lens.width, r->lens.height, image->channels, &sized));
    const gsf_result result = gsf_resize_image(ctx, image, GSF_RESIZE_PIL_BICUBIC, &sized);
    gsf_destroy_image(ctx, image);
    *image = sized;
    return result;
}

// Undistorts a photo after gsf__size_photo. *image: u8.
static gsf_result gsf__straighten_photo(gsf_context* ctx, const gsf__rectify* r, gsf_image* image) {
    gsf_image straight;
    if (r->lens.kind == GSF__LENS_PINHOLE) return GSF_OK;
    GSF__TRY(gsf__rectify_image(ctx, r, image, &straight));
    gsf_destroy_image(ctx, image);
    *image = straight;
    return GSF_OK;
}

// mask: packed u8 with one channel, of the photo's size; or NULL.
static gsf_result gsf__set_view(gsf_context* ctx, gsf_scene* scene, size_t view, const gsf_image* photo,
                                const gsf_image* mask) {
    const gsf__scene_state* state = (const gsf__scene_state*)scene->state;
    const gsf__rectify* r = &state->sources[view].rectify;
    const gsf_image colors = gsf__channels_of(photo, 0, photo->channels < 3 ? 1 : 3);
    gsf_image rgb, weight, joint;
    memset(&rgb, 0, sizeof rgb);
    memset(&weight, 0, sizeof weight);
    memset(&joint, 0, sizeof joint);
    gsf_result result = gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 3, &rgb);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &colors, &rgb);
    if (result == GSF_OK && !state->no_masks) result = gsf__view_weight(ctx, photo, mask, &weight);
    const int fits = photo->width == r->lens.width && photo->height == r->lens.height && r->lens.kind == GSF__LENS_PINHOLE;
    if (result == GSF_OK && !weight.data) {
        result = gsf__size_photo(ctx, r, &rgb);
        if (result == GSF_OK) result = gsf__straighten_photo(ctx, r, &rgb);
    }
    if (result == GSF_OK && !fits && weight.data) {
        result = gsf__join_weight(ctx, &rgb, &weight, &joint);
        gsf_destroy_image(ctx, &rgb);
        gsf_destroy_image(ctx, &weight);
        if (result == GSF_OK) result = gsf__size_photo(ctx, r, &joint);
        if (result == GSF_OK) result = gsf__joint_bytes(ctx, &joint);
        if (result == GSF_OK) result = gsf__straighten_photo(ctx, r, &joint);
        if (result == GSF_OK) result = gsf__part_weight(ctx, &joint, &rgb, &weight);
        gsf_destroy_image(ctx, &joint);
    }
    gsf_image* const old[2] = {&scene->views[view].image, &scene->views[view].weight};
    gsf_image made[2] = {rgb, weight};
    for (int k = 0; k < 2; k++) {
        gsf_destroy_image(ctx, result == GSF_OK ? old[k] : &made[k]);
        if (result == GSF_OK) *old[k] = made[k];
    }
    return result;
}

// Reads the mask NAME.png, or else NAME.EXT.png, where `name` is NAME.EXT with its path. *path receives the one found;
// *data is NULL if neither exists.
static gsf_result gsf__read_mask(gsf_context* ctx, const char* name, gsf_buffer* path, void** data, size_t* size) {
    const char *dot = strrchr(name, '.'), *slash = strrchr(name, '/');
    const size_t length = strlen(name), stem = dot && (!slash || dot > slash) ? (size_t)(dot - name) : length;
    gsf_buffer wanted;
    gsf_result result = GSF_OK;
    memset(&wanted, 0, sizeof wanted);
    for (int k = 0; k < 2 && !*data && result == GSF_OK; k++) {
        wanted.size = 0;
        gsf_append_bytes(ctx, &wanted, name, k ? length : stem);
        gsf_append_bytes(ctx, &wanted, ".png", 5);
        result = wanted.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf__read_if_there(ctx, "", wanted.data, path, data, size);
    }
    gsf_destroy_buffer(ctx, &wanted);
    return result;
}

// Returns whether two images have the same aspect ratio, up to the rounding of a size to whole pixels.
static int gsf__same_shape(const gsf_image* a, const gsf_image* b) {
    const int64_t bent = llabs(a->width * b->height - a->height * b->width);
    return bent <= a->width || bent <= a->height || bent <= b->width || bent <= b->height;
}

// Loads the mask file `name` (see gsf__read_mask), resized to the photo's size. out->data is NULL if there is none.
static gsf_result gsf__load_mask(gsf_context* ctx, const char* name, const gsf_image* photo, gsf_image* out) {
    gsf_buffer path;
    void* data = NULL;
    size_t size = 0;
    gsf_image file, bytes;
    memset(&path, 0, sizeof path);
    memset(&file, 0, sizeof file);
    memset(&bytes, 0, sizeof bytes);
    memset(out, 0, sizeof *out);
    gsf_result result = gsf__read_mask(ctx, name, &path, &data, &size);
    if (result != GSF_OK || !data) goto cleanup;
    result = gsf_decode_image(ctx, path.data, data, size, 1, &file);
    if (result != GSF_OK) goto cleanup;
    if (!gsf__same_shape(&file, photo)) {
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: %lld x %lld pixels differ in shape from the photo's %lld x %lld",
                          path.data, (long long)file.width, (long long)file.height, (long long)photo->width,
                          (long long)photo->height);
        goto cleanup;
    }
    file.color_space = GSF_COLOR_SRGB; // not a color: no conversion
    result = gsf_make_image(ctx, GSF_U8, file.width, file.height, 1, &bytes);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &file, &bytes);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_U8, photo->width, photo->height, 1, out);
    if (result == GSF_OK) result = gsf_resize_image(ctx, &bytes, GSF_RESIZE_PIL_BILINEAR, out);
    if (result != GSF_OK) gsf_destroy_image(ctx, out);
cleanup:
    gsf_destroy_image(ctx, &file);
    gsf_destroy_image(ctx, &bytes);
    gsf_free(ctx, data);
    gsf_destroy_buffer(ctx, &path);
    return result;
}

GSF_API gsf_result gsf_splat_set_view_image(gsf_context* ctx, gsf_scene* scene, size_t view, const gsf_image* photo) {
    if (view >= scene->view_count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "scene: view %zu of %zu", view, scene->view_count);
    if (photo->channels < 1 || photo->channels > 4)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "scene: a photo of %d channels", (int)photo->channels);
    return gsf__set_view(ctx, scene, view, photo, NULL);
}

GSF_API const char* gsf_splat_get_view_path(const gsf_scene* scene, size_t view) {
    const gsf__scene_state* state = (const gsf__scene_state*)scene->state;
    if (view >= scene->view_count || state->sources[view].path == SIZE_MAX) return NULL;
    return state->paths.data + state->sources[view].path;
}

GSF_API gsf_result gsf_splat_load_view_image(gsf_context* ctx, gsf_scene* scene, size_t view) {
    if (view >= scene->view_count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "scene: view %zu of %zu", view, scene->view_count);
    if (scene->views[view].image.data) return GSF_OK;
    const gsf__scene_state* state = (const gsf__scene_state*)scene->state;
    const gsf__view_source* source = &state->sources[view];
    if (source->path == SIZE_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "\"%s\": the scene came from memory; give its photo to %s",
                        scene->views[view].name, "gsf_splat_set_view_image");
    const char* path = state->paths.data + source->path;
    gsf_image photo, mask;
    memset(&mask, 0, sizeof mask);
    GSF__TRY(gsf_load_image(ctx, path, state->no_masks ? 3 : 0, &photo));
    gsf_result result = GSF_OK;
    if (photo.width != source->file_width || photo.height != source->file_height)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: %lld x %lld pixels, %lld x %lld when the scene was loaded", path,
                          (long long)photo.width, (long long)photo.height, (long long)source->file_width,
                          (long long)source->file_height);
    if (result == GSF_OK && !state->no_masks)
        result = gsf__load_mask(ctx, state->paths.data + source->mask, &photo, &mask);
    if (result == GSF_OK) result = gsf__set_view(ctx, scene, view, &photo, mask.data ? &mask : NULL);
    gsf_destroy_image(ctx, &photo);
    gsf_destroy_image(ctx, &mask);
    return result;
}

// ---- writing ----

static void gsf__put_le(gsf_context* ctx, gsf_buffer* out, uint64_t value, int bytes) {
    char p[8];
    gsf__store_le(p, value, bytes);
    gsf_append_bytes(ctx, out, p, (size_t)bytes);
}

static void gsf__put_double(gsf_context* ctx, gsf_buffer* out, double value) {
    char p[8];
    gsf__store_f64(p, value);
    gsf_append_bytes(ctx, out, p, sizeof p);
}

static int gsf__same_intrinsics(const gsf_camera* a, const gsf_camera* b) {
    return a->fx == b->fx && a->fy == b->fy && a->cx == b->cx && a->cy == b->cy && a->width == b->width &&
           a->height == b->height;
}

// Formats cameras.bin. camera_of: (view_count) receives the index of each view's camera. Cameras are numbered in the
// order of their first view.
static void gsf__format_cameras(gsf_context* ctx, const gsf_scene* scene, uint32_t* camera_of, gsf_buffer* out) {
    size_t count = 0;
    gsf__put_le(ctx, out, 0, 8); // the count, filled in below
    for (size_t i = 0; i < scene->view_count; i++) {
        const gsf_camera* c = &scene->views[i].camera;
        camera_of[i] = (uint32_t)count;
        // Comparing with the previous and the first view suffices for a single camera and for photos sorted by camera.
        if (i && gsf__same_intrinsics(c, &scene->views[i - 1].camera)) camera_of[i] = camera_of[i - 1];
        else if (i && gsf__same_intrinsics(c, &scene->views[0].camera)) camera_of[i] = 0;
        if (camera_of[i] != count) continue;
        gsf__put_le(ctx, out, ++count, 4);
        gsf__put_le(ctx, out, 1, 4); // PINHOLE
        gsf__put_le(ctx, out, (uint64_t)c->width, 8);
        gsf__put_le(ctx, out, (uint64_t)c->height, 8);
        gsf__put_double(ctx, out, c->fx);
        gsf__put_double(ctx, out, c->fy);
        gsf__put_double(ctx, out, c->cx);
        gsf__put_double(ctx, out, c->cy);
    }
    if (!out->failed) gsf__store_le(out->data, count, 8);
}

// Sorts the observations by view (counting sort). first: (view_count + 1); point_of, slot_of: (observations). The k-th
// observation of view v is point point_of[first[v] + k]; track entry e is observation slot_of[e] of its view.
static void gsf__sort_observations(const gsf_scene* scene, const uint8_t* keep, size_t* first, size_t* point_of,
                                   uint32_t* slot_of) {
    memset(first, 0, (scene->view_count + 1) * sizeof *first);
    for (size_t p = 0; p < scene->point_count; p++)
        for (size_t e = scene->track_begin[p]; e < scene->track_begin[p + 1] && (!keep || keep[p]); e++)
            slot_of[e] = (uint32_t)first[scene->track_views[e] + 1]++;
    for (size_t v = 0; v < scene->view_count; v++) first[v + 1] += first[v];
    for (size_t p = 0; p < scene->point_count; p++)
        for (size_t e = scene->track_begin[p]; e < scene->track_begin[p + 1] && (!keep || keep[p]); e++)
            point_of[first[scene->track_views[e]] + slot_of[e]] = p;
}

static void gsf__format_images(gsf_context* ctx, const gsf_scene* scene, const uint32_t* camera_of, const size_t* first,
                               const size_t* point_of, gsf_buffer* out) {
    gsf__put_le(ctx, out, scene->view_count, 8);
    for (size_t v = 0; v < scene->view_count; v++) {
        const gsf_scene_view* view = &scene->views[v];
        double q[4];
        gsf__quat_of(view->camera.w2c, q);
        gsf__put_le(ctx, out, view->image_id, 4);
        for (int k = 0; k < 4; k++) gsf__put_double(ctx, out, q[k]);
        for (int k = 0; k < 3; k++) gsf__put_double(ctx, out, view->camera.w2c[12 + k]);
        gsf__put_le(ctx, out, camera_of[v] + 1u, 4);
        gsf_append_bytes(ctx, out, view->name, strlen(view->name) + 1);
        gsf__put_le(ctx, out, first[v + 1] - first[v], 8);
        for (size_t k = first[v]; k < first[v + 1]; k++) {
            double x = 0.0, y = 0.0, depth;
            (void)gsf_project_point(&view->camera, scene->points + 3 * point_of[k], &x, &y, &depth);
            gsf__put_double(ctx, out, x);
            gsf__put_double(ctx, out, y);
            gsf__put_le(ctx, out, scene->point_ids[point_of[k]], 8);
        }
    }
}

static void gsf__format_points(gsf_context* ctx, const gsf_scene* scene, const uint8_t* keep, const uint32_t* slot_of,
                               gsf_buffer* out) {
    size_t kept = 0;
    for (size_t p = 0; p < scene->point_count; p++) kept += !keep || keep[p];
    gsf__put_le(ctx, out, kept, 8);
    for (size_t p = 0; p < scene->point_count; p++) {
        if (keep && !keep[p]) continue;
        gsf__put_le(ctx, out, scene->point_ids[p], 8);
        for (size_t k = 0; k < 3; k++) gsf__put_double(ctx, out, scene->points[3 * p + k]);
        gsf_append_bytes(ctx, out, (const char*)scene->colors + 3 * p, 3);
        gsf__put_double(ctx, out, -1.0); // reprojection error: unknown
        gsf__put_le(ctx, out, scene->track_begin[p + 1] - scene->track_begin[p], 8);
        for (size_t e = scene->track_begin[p]; e < scene->track_begin[p + 1]; e++) {
            gsf__put_le(ctx, out, scene->views[scene->track_views[e]].image_id, 4);
            gsf__put_le(ctx, out, slot_of[e], 4);
        }
    }
}

GSF_API gsf_result gsf_splat_save_colmap(gsf_context* ctx, const gsf_scene* scene, const uint8_t* keep,
                                         const char* folder) {
    static const char* const names[3] = {"cameras", "images", "points3D"};
    const size_t observations = scene->point_count ? scene->track_begin[scene->point_count] : 0;
    gsf_buffer files[3], path;
    memset(files, 0, sizeof files);
    memset(&path, 0, sizeof path);
    uint32_t* camera_of = (uint32_t*)gsf_alloc(ctx, scene->view_count + 1, sizeof *camera_of);
    size_t* first = (size_t*)gsf_alloc(ctx, scene->view_count + 1, sizeof *first);
    size_t* point_of = (size_t*)gsf_alloc(ctx, observations + 1, sizeof *point_of);
    uint32_t* slot_of = (uint32_t*)gsf_alloc(ctx, observations + 1, sizeof *slot_of);
    gsf_result result = camera_of && first && point_of && slot_of ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) {
        gsf__format_cameras(ctx, scene, camera_of, &files[0]);
        gsf__sort_observations(scene, keep, first, point_of, slot_of);
        gsf__format_images(ctx, scene, camera_of, first, point_of, &files[1]);
        gsf__format_points(ctx, scene, keep, slot_of, &files[2]);
    }
    for (int k = 0; k < 3; k++)
        if (files[k].failed) result = GSF_ERROR_OUT_OF_MEMORY;
    for (int k = 2; k >= 0 && result == GSF_OK; k--) { // cameras last: readers look for them first
        path.size = 0;
        gsf_append_text(ctx, &path, "%s/sparse/0/%s.bin", folder, names[k]);
        result = path.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path.data, files[k].data, files[k].size);
    }
    for (int k = 0; k < 3; k++) gsf_destroy_buffer(ctx, &files[k]);
    gsf_destroy_buffer(ctx, &path);
    gsf_free(ctx, camera_of);
    gsf_free(ctx, first);
    gsf_free(ctx, point_of);
    gsf_free(ctx, slot_of);
    return result;
}

GSF_API void gsf_splat_split_views(size_t n, size_t test_every, size_t train_target, uint32_t* train,
                                   size_t* train_count, uint32_t* test, size_t* test_count) {
    size_t tests = 0, rest = 0;
    for (size_t i = 0; i < n; i++) {
        if (test_every && i % test_every == 0) {
            if (test) test[tests] = (uint32_t)i;
            tests++;
        } else {
            rest++;
        }
    }
    const size_t count = train_target && rest ? train_target : rest;
    // The j-th view that is not a test view is view j + j / (test_every - 1) + 1 (without test views: view j). With
    // test_every = 1 there are none.
    const double step = count > 1 ? (double)(rest ? rest - 1 : 0) / (double)(count - 1) : 0.0;
    for (size_t i = 0; i < count && train; i++) {
        size_t j = train_target ? (size_t)gsf__round_half_even((double)i * step) : i;
        if (train_target && i == count - 1 && i > 0) j = rest - 1; // numpy.linspace sets its last value exactly
        train[i] = (uint32_t)(test_every ? j + j / (test_every - 1) + 1 : j);
    }
    if (train_count) *train_count = count;
    if (test_count) *test_count = tests;
}

// ---- >>neighbours --------------------------------------------------------------

/* Exact nearest neighbours with a balanced, pointerless kd-tree. Node i of level l covers the rows
   [n i / 2^l, n (i+1) / 2^l) of a permutation of the points; its bounding box is boxes[2^l - 1 + i]. A node is split at
   the median along the widest axis of its box, so the depth is log2(n / 8) for any cloud, clustered or not. */
typedef struct gsf__knn_tree {
    size_t count;
    uint32_t levels;  // level of the leaves
    double* points;   // (count,3) in tree order
    uint32_t* rows;   // (count) the caller's row of each point, in tree order
    double* boxes;    // (2^(levels+1) - 1, 6): minimum xyz, maximum xyz
    gsf__arena arena;
} gsf__knn_tree;

enum { GSF__KNN_LEAF = 8, GSF__KNN_MAX = 64, GSF__KNN_CHUNK = 128, GSF__KNN_SPLIT = 8 };

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

// A coordinate close to that of the point which sorting [begin,end) along the axis would bring to nth. From a pseudorandom,
// but reproducible sample.
static double gsf__knn_pivot(const gsf__knn_tree* tree, size_t begin, size_t nth, size_t end, int axis) {
    enum { MOST = 31 };
    const size_t size = end - begin, count = size > 32 * MOST ? MOST : size > 32 ? 3 : 1;
    double sample[MOST];
    for (size_t n = 0; n < count; n++) { // sorted
        const size_t pick = begin + (size_t)(gsf_draw_bits(begin, end, nth + n) % size);
        const double x = tree->points[3 * pick + (size_t)axis];
        size_t at = n;
        for (; at > 0 && sample[at - 1] > x; at--) sample[at] = sample[at - 1];
        sample[at] = x;
    }
    return sample[(nth - begin) * count / size];
}

// Quickselect: afterwards no point in [begin,nth) is above, and none in [nth,end) below, point nth along the axis. The
// three-way partition handles equal coordinates in linear time.
static void gsf__knn_select(gsf__knn_tree* tree, size_t begin, size_t nth, size_t end, int axis) {
    while (end - begin > 1) {
        const double pivot = gsf__knn_pivot(tree, begin, nth, end, axis);
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

// Makes the box of a node, and divides its points unless it is a leaf.
static void gsf__knn_build_node(gsf__knn_tree* tree, uint32_t level, size_t node) {
    const size_t begin = gsf__knn_begin(tree, level, node), end = gsf__knn_begin(tree, level, node + 1);
    double* box = tree->boxes + 6 * (((size_t)1 << level) - 1 + node);
    for (int k = 0; k < 3; k++) box[k] = box[3 + k] = tree->points[3 * begin + (size_t)k];
    for (size_t i = begin + 1; i < end; i++)
        for (int k = 0; k < 3; k++) {
            const double x = tree->points[3 * i + (size_t)k];
            if (x < box[k]) box[k] = x;
            if (x > box[3 + k]) box[3 + k] = x;
        }
    if (level == tree->levels) return;
    int axis = 0;
    for (int k = 1; k < 3; k++)
        if (box[3 + k] - box[k] > box[3 + axis] - box[axis]) axis = k;
    gsf__knn_select(tree, begin, gsf__knn_begin(tree, level + 1, 2 * node + 1), end, axis);
}

typedef struct gsf__knn_build_job {
    gsf__knn_tree* tree;
    uint32_t level, last;
} gsf__knn_build_job;

// A node of the level, and those below it down to the level `last`: a subtree of a large tree fits the cache.
static void gsf__knn_build_chunk(void* arg, size_t node, int32_t worker) {
    (void)worker;
    const gsf__knn_build_job* job = (const gsf__knn_build_job*)arg;
    for (uint32_t level = job->level; level <= job->last; level++) {
        const uint32_t below = level - job->level;
        for (size_t i = node << below; i < (node + 1) << below; i++) gsf__knn_build_node(job->tree, level, i);
    }
}

static int gsf__point_counts(const double* points, const uint8_t* keep, size_t i) { // kept, and finite
    const double* p = points + 3 * i;
    return (!keep || keep[i]) && isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2]);
}

// Builds a tree of those of the `count` points (stride 3) whose byte in `keep` is not zero (NULL: all). Points with a
// non-finite coordinate are skipped; tree->count is the number of points in the tree. Free tree->arena, also after an error.
static gsf_result gsf__knn_build(gsf_context* ctx, const double* points, size_t count, const uint8_t* keep,
                                 gsf__knn_tree* tree) {
    memset(tree, 0, sizeof *tree);
    tree->arena.ctx = ctx;
    if ((uint64_t)count >= UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "points: %zu do not fit 32-bit indices", count);
    size_t n = 0;
    for (size_t i = 0; i < count; i++) n += (size_t)gsf__point_counts(points, keep, i);
    while (n >> tree->levels > GSF__KNN_LEAF) tree->levels++;
    tree->points = (double*)gsf__arena_alloc(&tree->arena, n, 3 * sizeof(double));
    tree->rows = (uint32_t*)gsf__arena_alloc(&tree->arena, n, sizeof(uint32_t));
    tree->boxes = (double*)gsf__arena_alloc(&tree->arena, (size_t)2 << tree->levels, 6 * sizeof(double));
    if (tree->arena.failed) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) {
        if (!gsf__point_counts(points, keep, i)) continue;
        memcpy(tree->points + 3 * tree->count, points + 3 * i, 3 * sizeof(double));
        tree->rows[tree->count++] = (uint32_t)i;
    }
    if (n == 0) return GSF_OK;
    gsf__knn_build_job job;
    job.tree = tree;
    for (job.level = 0; job.level <= tree->levels; job.level = job.last + 1) {
        job.last = job.level < GSF__KNN_SPLIT ? job.level : tree->levels;
        gsf__parallel_for(ctx, (size_t)1 << job.level, gsf__knn_build_chunk, &job);
    }
    return GSF_OK;
}

static double gsf__distance2(const double a[3], const double b[3]) {
    const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
    return x * x + y * y + z * z;
}

static double gsf__knn_box_distance2(const double a[6], const double b[6]) {
    double sum = 0.0;
    for (int k = 0; k < 3; k++) {
        const double below = b[k] - a[3 + k], above = a[k] - b[3 + k], d = below > above ? below : above;
        sum += d > 0.0 ? d * d : 0.0;
    }
    return sum;
}

typedef struct gsf__knn_near { // of each point of a leaf, the other points that are nearest to it, nearest first
    size_t first, end; // the leaf
    int wanted, found[GSF__KNN_LEAF + 1];
    double distance2[GSF__KNN_LEAF + 1][GSF__KNN_MAX];
    size_t places[GSF__KNN_LEAF + 1][GSF__KNN_MAX]; // in tree order
    double beyond; // squared distance from which on no point is wanted
} gsf__knn_near;

static void gsf__knn_meet(const gsf__knn_tree* tree, size_t leaf, gsf__knn_near* nearby) {
    const size_t first = gsf__knn_begin(tree, tree->levels, leaf), end = gsf__knn_begin(tree, tree->levels, leaf + 1);
    nearby->beyond = 0.0;
    for (size_t i = nearby->first; i < nearby->end; i++) {
        double *distance2 = nearby->distance2[i - nearby->first], beyond = (double)INFINITY;
        size_t* places = nearby->places[i - nearby->first];
        int found = nearby->found[i - nearby->first];
        if (found == nearby->wanted) beyond = distance2[found - 1];
        for (size_t j = first; j < end; j++) {
            const double d = gsf__distance2(tree->points + 3 * i, tree->points + 3 * j);
            if (d >= beyond || j == i) continue;
            int at = found < nearby->wanted ? found++ : found - 1;
            for (; at > 0 && distance2[at - 1] > d; at--) {
                distance2[at] = distance2[at - 1];
                places[at] = places[at - 1];
            }
            distance2[at] = d;
            places[at] = j;
            if (found == nearby->wanted) beyond = distance2[found - 1];
        }
        nearby->found[i - nearby->first] = found;
        if (beyond > nearby->beyond) nearby->beyond = beyond;
    }
}

// Finds the k points nearest to each point of a leaf (k <= GSF__KNN_MAX), or all if there are fewer. One search serves all
// points of the leaf. Ties depend only on the tree.
static void gsf__knn_leaf(const gsf__knn_tree* tree, size_t leaf, int k, gsf__knn_near* nearby) {
    struct { size_t node; double distance2; uint32_t level; } stack[40];
    const double* box = tree->boxes + 6 * (((size_t)1 << tree->levels) - 1 + leaf);
    nearby->first = gsf__knn_begin(tree, tree->levels, leaf);
    nearby->end = gsf__knn_begin(tree, tree->levels, leaf + 1);
    nearby->wanted = k;
    memset(nearby->found, 0, sizeof nearby->found);
    gsf__knn_meet(tree, leaf, nearby);
    for (uint32_t up = 0; up < tree->levels; up++) { // the other half of each node that contains the leaf
        int depth = 1;
        stack[0].level = tree->levels - up;
        stack[0].node = (leaf >> up) ^ 1;
        stack[0].distance2 =
            gsf__knn_box_distance2(box, tree->boxes + 6 * (((size_t)1 << stack[0].level) - 1 + stack[0].node));
        while (depth > 0) {
            depth--;
            size_t node = stack[depth].node;
            uint32_t level = stack[depth].level;
            if (stack[depth].distance2 >= nearby->beyond) continue;
            while (level < tree->levels) { // descend to the nearer child, push the farther
                level++;
                const double* boxes = tree->boxes + 6 * (((size_t)1 << level) - 1 + 2 * node);
                const double left = gsf__knn_box_distance2(box, boxes), right = gsf__knn_box_distance2(box, boxes + 6);
                const size_t far_bit = left <= right;
                stack[depth].node = 2 * node + far_bit;
                stack[depth].distance2 = far_bit ? right : left;
                stack[depth++].level = level;
                node = 2 * node + (1 - far_bit);
            }
            gsf__knn_meet(tree, node, nearby);
        }
    }
}

// Chunks of leaves.
static size_t gsf__knn_chunks(const gsf__knn_tree* tree) {
    return tree->count ? (((size_t)1 << tree->levels) + GSF__KNN_CHUNK - 1) / GSF__KNN_CHUNK : 0;
}

static size_t gsf__knn_chunk_end(const gsf__knn_tree* tree, size_t chunk) {
    const size_t leaves = (size_t)1 << tree->levels, end = (chunk + 1) * GSF__KNN_CHUNK;
    return end < leaves ? end : leaves;
}

typedef struct gsf__init_job {
    const gsf__knn_tree* tree;
    float* log_scales; // in tree order
} gsf__init_job;

static void gsf__init_scales_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__init_job* job = (const gsf__init_job*)arg;
    gsf__knn_near nearby;
    for (size_t leaf = chunk * GSF__KNN_CHUNK; leaf < gsf__knn_chunk_end(job->tree, chunk); leaf++) {
        gsf__knn_leaf(job->tree, leaf, 3, &nearby);
        for (size_t i = nearby.first; i < nearby.end; i++) {
            const int found = nearby.found[i - nearby.first];
            double mean = 0.0;
            for (int k = 0; k < found; k++) mean += nearby.distance2[i - nearby.first][k];
            if (found) mean /= found;
            job->log_scales[i] = (float)(0.5 * gsf__log_f64(mean > 1e-7 ? mean : 1e-7));
        }
    }
}

#define GSF__SH_C0 0.28209479177387814 // SH basis function 0

GSF_API gsf_result gsf_splat_make_from_points(gsf_context* ctx, const double* points, const uint8_t* colors,
                                              size_t count, const uint8_t* keep, int32_t sh_degree,
                                              const double origin[3], gsf_splats* out) {
    memset(out, 0, sizeof *out);
    if (count && (!points || !colors))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "splats from points: points or colours are missing");
    if (origin && !(isfinite(origin[0]) && isfinite(origin[1]) && isfinite(origin[2])))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "splats from points: the origin is not finite");
    gsf__knn_tree tree;
    gsf_result result = gsf__knn_build(ctx, points, count, keep, &tree);
    float* log_scales = NULL;
    uint32_t* order = NULL; // row -> position in the tree
    if (result == GSF_OK) {
        log_scales = (float*)gsf__arena_alloc(&tree.arena, tree.count, sizeof(float));
        order = (uint32_t*)gsf__arena_alloc(&tree.arena, count, sizeof(uint32_t));
        result = tree.arena.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_splat_make(ctx, tree.count, sh_degree, out);
    }
    if (result == GSF_OK) {
        gsf__init_job job;
        job.tree = &tree;
        job.log_scales = log_scales;
        gsf__parallel_for(ctx, gsf__knn_chunks(&tree), gsf__init_scales_chunk, &job);

        size_t kept = 0, n = 0;
        for (size_t i = 0; i < count; i++) order[i] = UINT32_MAX;
        for (size_t i = 0; i < tree.count; i++) order[tree.rows[i]] = (uint32_t)i;
        if (origin) memcpy(out->origin, origin, sizeof out->origin);
        const size_t sh_floats = 3 * (size_t)gsf_splat_count_sh(sh_degree);
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
            gsf_log(ctx, GSF_LOG_WARNING, "%zu points with a non-finite coordinate were skipped", kept - n);
    }
    gsf__arena_free(&tree.arena);
    return result;
}

// ---- >>visibility --------------------------------------------------------------

// Before an array or a variable that kernels read in whole cache lines: a vector across two is slow to load, and slower
// to load soon after it was stored.
#if defined(__GNUC__) || defined(__clang__)
#define GSF__LINES __attribute__((aligned(64)))
#else
#define GSF__LINES
#endif

static int gsf__lowest_bit(uint32_t mask) {
#if defined(__GNUC__) || defined(__clang__)
    return __builtin_ctz(mask);
#else
    int bit = 0;
    while (!(mask >> bit & 1u)) bit++;
    return bit;
#endif
}

typedef struct gsf__disc { // Embree reads it where it lies, centre with radius and normal by 16 bytes each
    float center[3], radius;
    float normal[3], inverse2; // of unit length; 1 / radius^2
} gsf__disc;

typedef struct gsf__discs { // the points as oriented discs, in tree order (neighbours are close in memory)
    size_t count;
    double origin[3];  // origin of the float coordinates
    gsf__disc* all;    // (count)
    uint32_t* rows;    // (count) index of the scene's point
    uint32_t* nearest; // (count,near_count) indices of the neighbours in tree order
    int near_count;
    uint8_t* oriented; // (count) 1: the normal points towards the views in the neighbours' tracks
} gsf__discs;

#define GSF__VIS_ANY_DISC 1e-30f // less than any disc adds, yet positive: a cover of 0 reaches a limit of 0

static gsf_visibility_desc gsf__visibility_desc_defaults(const gsf_visibility_desc* desc) {
    gsf_visibility_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.neighbours == 0) d.neighbours = 12;
    if (d.radius_neighbour == 0) d.radius_neighbour = 6;
    if (d.radius_scale == 0.0f) d.radius_scale = 1.4f;
    d.tolerance = gsf__or_zero(d.tolerance, 0.7f);
    d.coverage = d.coverage < 0.0f ? GSF__VIS_ANY_DISC : gsf__or_zero(d.coverage, 2.0f);
    d.min_grazing_cos = gsf__or_zero(d.min_grazing_cos, 0.02f);
    return d;
}

static gsf_result gsf__check_views(gsf_context* ctx, const char* what, const gsf_scene* scene, const uint32_t* views,
                                   size_t view_count) {
    if (view_count && !views) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: views is NULL", what);
    for (size_t i = 0; i < view_count; i++) {
        if (views[i] >= scene->view_count)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s: view %u does not exist, the scene has %zu", what,
                            (unsigned)views[i], scene->view_count);
        GSF__TRY(gsf_check_camera(ctx, &scene->views[views[i]].camera));
    }
    return GSF_OK;
}

static gsf_result gsf__visibility_check(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                        size_t view_count, const gsf_visibility_desc* d) {
    if ((unsigned)d->method > GSF_VISIBILITY_RAYS)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "visible points: method %d", (int)d->method);
    const gsf__field fields[] = {
        {"neighbours", (double)d->neighbours, 3, GSF__KNN_MAX},
        {"radius_neighbour", (double)d->radius_neighbour, 1, GSF__KNN_MAX},
        {"radius_scale", (double)d->radius_scale, FLT_MIN, 1e6},
        {"tolerance", (double)d->tolerance, 0, 1e6},
        {"coverage", (double)d->coverage, FLT_MIN, INFINITY},
        {"min_grazing_cos", (double)d->min_grazing_cos, 0, 0.999999},
    };
    GSF__TRY(gsf__check_fields(ctx, "visible points", fields, GSF__COUNT(fields)));
    return gsf__check_views(ctx, "visible points", scene, views, view_count);
}

typedef struct gsf__disc_job {
    const gsf__knn_tree* tree;
    const gsf_visibility_desc* desc;
    gsf__discs* discs;
} gsf__disc_job;

// Makes the disc of the point at position i, given the points nearest to it.
static void gsf__disc_make(const gsf__disc_job* job, size_t i, const size_t* places, const double* distance2, int found) {
    const gsf__knn_tree* tree = job->tree;
    const double* p = tree->points + 3 * i;
    const int used = found < job->desc->neighbours ? found : job->desc->neighbours;
    double mean[3] = {0.0, 0.0, 0.0}, cov[9]; // of the point p and its neighbours; mean is relative to p
    memset(cov, 0, sizeof cov);
    for (int k = 0; k < used; k++)
        for (int a = 0; a < 3; a++) mean[a] += (tree->points[3 * places[k] + (size_t)a] - p[a]) / (used + 1);
    for (int k = -1; k < used; k++) {
        double d[3];
        for (int a = 0; a < 3; a++) d[a] = (k < 0 ? 0.0 : tree->points[3 * places[k] + (size_t)a] - p[a]) - mean[a];
        for (int a = 0; a < 3; a++)
            for (int b = 0; b < 3; b++) cov[3 * a + b] += d[a] * d[b];
    }
    double values[3], axes[9];
    gsf__mat3_eigen(cov, values, axes);
    const double* normal = axes + 6; // the direction of least variance
    uint32_t* nearest = job->discs->nearest + (size_t)job->discs->near_count * i;
    for (int k = 0; k < used; k++) nearest[k] = (uint32_t)places[k];
    const int at = found < job->desc->radius_neighbour ? found : job->desc->radius_neighbour;
    gsf__disc* disc = job->discs->all + i;
    for (int a = 0; a < 3; a++) {
        disc->center[a] = (float)(p[a] - job->discs->origin[a]);
        disc->normal[a] = (float)normal[a];
    }
    disc->radius = (float)(at ? (double)job->desc->radius_scale * sqrt(distance2[at - 1]) : 0.0);
    job->discs->rows[i] = tree->rows[i];
}

static void gsf__discs_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__disc_job* job = (const gsf__disc_job*)arg;
    const gsf_visibility_desc* desc = job->desc;
    const int wanted = desc->neighbours > desc->radius_neighbour ? desc->neighbours : desc->radius_neighbour;
    gsf__knn_near nearby;
    for (size_t leaf = chunk * GSF__KNN_CHUNK; leaf < gsf__knn_chunk_end(job->tree, chunk); leaf++) {
        gsf__knn_leaf(job->tree, leaf, wanted, &nearby);
        for (size_t i = nearby.first, k = 0; i < nearby.end; i++, k++)
            gsf__disc_make(job, i, nearby.places[k], nearby.distance2[k], nearby.found[k]);
    }
}

// The value at position nth of the sorted values, which are rearranged.
static float gsf__nth_value(float* values, size_t count, size_t nth) {
    size_t begin = 0, end = count;
    for (;;) {
        const float pivot = values[begin + (size_t)(gsf_draw_bits(begin, end, nth) % (end - begin))];
        size_t below = begin, above = end;
        for (size_t i = begin; i < above;) {
            const float x = values[i];
            if (x < pivot) {
                values[i++] = values[below];
                values[below++] = x;
            } else if (x > pivot) {
                values[i] = values[--above];
                values[above] = x;
            } else {
                i++;
            }
        }
        if (nth < below) end = below;
        else if (nth >= above) begin = above;
        else return pivot;
    }
}

// Makes the discs. Normals come from a PCA of the neighbours. The radius is the distance to a neighbour, at most 3
// times the median (else isolated points would hide whole walls) and at least 1e-5 of the coordinates (ray tests in
// float miss smaller discs, as measured with Embree 3.13.5).
static gsf_result gsf__discs_make(gsf__arena* arena, const gsf_scene* scene, const double origin[3],
                                  const gsf_visibility_desc* desc, gsf__discs* discs) {
    gsf_context* ctx = arena->ctx;
    gsf__knn_tree tree;
    gsf__disc_job job;
    float* radii = NULL;
    gsf_result result = gsf__knn_build(ctx, scene->points, scene->point_count, NULL, &tree);
    const size_t count = tree.count;
    if (result != GSF_OK) goto cleanup;
    memcpy(discs->origin, origin, sizeof discs->origin);
    discs->near_count = count <= (size_t)desc->neighbours ? (int)count - (count > 0) : desc->neighbours;
    discs->all = (gsf__disc*)gsf__arena_alloc(arena, count, sizeof(gsf__disc));
    discs->rows = (uint32_t*)gsf__arena_alloc(arena, count, sizeof(uint32_t));
    discs->nearest = (uint32_t*)gsf__arena_alloc(arena, count, (size_t)(discs->near_count + 1) * sizeof(uint32_t));
    discs->oriented = (uint8_t*)gsf__arena_alloc_zeroed(arena, count, 1);
    radii = (float*)gsf__arena_alloc(&tree.arena, count, sizeof(float));
    result = arena->failed || !radii ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    if (result != GSF_OK) goto cleanup;
    discs->count = count;
    job.tree = &tree;
    job.desc = desc;
    job.discs = discs;
    gsf__parallel_for(ctx, gsf__knn_chunks(&tree), gsf__discs_chunk, &job);
    {
        size_t n = 0;
        for (size_t i = 0; i < count; i++) // clusters of identical points have radius 0 and are ignored
            if (discs->all[i].radius > 0.0f) radii[n++] = discs->all[i].radius;
        const float most = n ? 3.0f * gsf__nth_value(radii, n, n / 2) : 0.0f;
        for (size_t i = 0; i < count; i++) {
            gsf__disc* disc = discs->all + i;
            const float least = 1e-5f * (fabsf(disc->center[0]) + fabsf(disc->center[1]) + fabsf(disc->center[2]));
            if (disc->radius > most) disc->radius = most;
            if (disc->radius < least) disc->radius = least;
            disc->inverse2 = 1.0f / (disc->radius * disc->radius);
        }
    }
    result = gsf__check_cancel(ctx);
cleanup:
    gsf__arena_free(&tree.arena);
    return result;
}

typedef struct gsf__eye { // a view, prepared for ray tests
    gsf_camera camera;
    double center[3]; // relative to the discs' origin
    uint32_t view;
} gsf__eye;

typedef struct gsf__sight { // a point as seen from an eye
    double direction[3]; // unit, from the eye, in the discs' axes
    double distance;
    double u, v;         // pixel
} gsf__sight;

typedef struct gsf__disc_box { int16_t x0, x1, y0, y1; } gsf__disc_box; // cells [x0,x1) x [y0,y1)

enum { GSF__VIS_BINS = 41 }; // each covers 0.05 of the distance between two unit directions, which is at most 2

typedef struct gsf__vis_counts {
    size_t rays, culled;
    // Points in frame, and those whose track has the view, by gsf__vis_apart.
    uint32_t tries[GSF__VIS_BINS], finds[GSF__VIS_BINS];
} gsf__vis_counts;

typedef struct gsf__look { // of an eye at the discs
    const gsf__eye* eye;
    float* apart;    // (count) gsf__vis_apart
    float* evidence; // (count) log likelihood ratio of being visible; NULL: no tracks
} gsf__look;

typedef struct gsf__rays gsf__rays;
typedef struct gsf__unseen gsf__unseen;
typedef struct gsf__hiders gsf__hiders;

enum { GSF__VIS_CHUNK = 1024, GSF__VIS_LOOKS = 8, GSF__VIS_BANDS = 32, GSF__VIS_MAX_SIDE = 4096 };

typedef struct gsf__vis_job {
    gsf__arena arena;          // all arrays
    const gsf_visibility_desc* desc;
    gsf__discs discs;
    gsf__eye* eyes;
    size_t eye_count;
    uint8_t* seen;             // (count) points set on entry are not traced
    gsf__vis_counts* counts;   // per chunk of discs, so that summing needs no atomics
    void* embree_scene;
    gsf__unseen* unseen;       // per worker; see >>embree
    uint32_t (*aim)(const gsf__unseen* unseen, int first, float grazing, gsf__rays* rays);
    uint32_t (*hide)(const gsf__disc* discs, gsf__rays* rays, gsf__hiders* hiders, uint32_t open);
    // evidence from the tracks
    const gsf_scene* scene;
    double* centers;           // (view_count,3) centres of all views, relative to the discs' origin
    float* regions;            // (chunks,6) bounding box of a chunk's disc centres: minimum, maximum
    float* facing;             // (count,3) sum of the unit directions to the point from the views of its track
    float *apart, *evidence;   // (GSF__VIS_LOOKS,count) of the looks; NULL: no tracks
    double found[GSF__VIS_BINS], missed[GSF__VIS_BINS]; // the evidence if the view is, or is not, in the track
    gsf__look looks[GSF__VIS_LOOKS]; // of the eyes that are tested together
    size_t look_count;
    // without Embree: the image of one look as a grid of cells, each with the points to test
    const gsf__look* look;
    int32_t* cells;            // (count) cell of the point, -1 = none
    gsf__disc_box* boxes;      // (count) cells that the disc touches
    gsf__disc_box* chunk_boxes; // (chunks) rows of cells that a chunk's discs touch
    uint32_t* cell_begin;      // (cells + 2) offsets into cell_points
    uint32_t* cell_points;
    gsf__sight* sights;        // (count) valid for points that have a cell
    float* limits;             // (count) their gsf__vis_limit
    double* cover;             // (count) accumulated cover of the discs in front of the point
    int32_t side;              // number of cells along each side of the image
} gsf__vis_job;

static void gsf__vis_run(gsf_context* ctx, gsf__vis_job* job, void (*chunk)(void* arg, size_t chunk, int32_t worker)) {
    gsf__parallel_for(ctx, (job->discs.count + GSF__VIS_CHUNK - 1) / GSF__VIS_CHUNK, chunk, job);
}

static void gsf__vis_region(const gsf__discs* discs, size_t first, size_t end, float region[6]) {
    for (int k = 0; k < 3; k++) region[k] = region[3 + k] = discs->all[first].center[k];
    for (size_t i = first + 1; i < end; i++)
        for (int k = 0; k < 3; k++) {
            const float x = discs->all[i].center[k];
            if (x < region[k]) region[k] = x;
            if (x > region[3 + k]) region[3 + k] = x;
        }
}

// Tests a bounding box against the eye's frustum: -1 if it is entirely outside one of the five planes, 1 if it is
// entirely inside all of them, else 0.
static int gsf__vis_side(const gsf__eye* eye, const float region[6]) {
    const gsf_camera* camera = &eye->camera;
    const double w = (double)camera->width, h = (double)camera->height;
    const double planes[5][3] = { // the dot product with a point in camera axes is positive inside
        {0.0, 0.0, 1.0},
        {camera->fx, 0.0, camera->cx}, {-camera->fx, 0.0, w - camera->cx},
        {0.0, camera->fy, camera->cy}, {0.0, -camera->fy, h - camera->cy},
    };
    int side = 1;
    for (int p = 0; p < 5; p++) {
        double least = 0.0, most = 0.0, rounding = 0.0;
        for (int k = 0; k < 3; k++) {
            const double* m = camera->w2c + 4 * k;
            const double n = planes[p][0] * m[0] + planes[p][1] * m[1] + planes[p][2] * m[2];
            const double a = n * ((double)region[k] - eye->center[k]), b = n * ((double)region[3 + k] - eye->center[k]);
            least += a < b ? a : b;
            most += a < b ? b : a;
            rounding += 1e-9 * (fabs(a) + fabs(b));
        }
        if (most < -rounding) return -1;
        if (!(least > rounding)) side = 0;
    }
    return side;
}

// Frustum and grazing-angle tests; returns 0 if the point needs no ray.
static int gsf__vis_sight(const gsf__vis_job* job, const gsf__eye* eye, size_t i, gsf__sight* out) {
    const gsf__disc* disc = job->discs.all + i;
    const double* m = eye->camera.w2c;
    double d[3], c[3];
    for (int k = 0; k < 3; k++) d[k] = (double)disc->center[k] - eye->center[k];
    for (int r = 0; r < 3; r++) c[r] = m[r] * d[0] + m[4 + r] * d[1] + m[8 + r] * d[2];
    if (!(c[2] > 0.0)) return 0;
    out->u = eye->camera.fx * c[0] / c[2] + eye->camera.cx;
    out->v = eye->camera.fy * c[1] / c[2] + eye->camera.cy;
    if (!(out->u >= 0.0 && out->v >= 0.0 && out->u < eye->camera.width && out->v < eye->camera.height)) return 0;
    out->distance = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int k = 0; k < 3; k++) out->direction[k] = d[k] / out->distance;
    const double cosine = out->direction[0] * (double)disc->normal[0] + out->direction[1] * (double)disc->normal[1] +
                          out->direction[2] * (double)disc->normal[2];
    return fabs(cosine) >= (double)job->desc->min_grazing_cos;
}

// Distance between the unit directions to point i from the eye and from another view of its track, minimised over these
// views (0.1 is about 6 degrees); -1 if there is no other view. *tracked: whether the eye's own view is in the track.
static float gsf__vis_apart(const gsf__vis_job* job, const gsf__eye* eye, size_t i, const gsf__sight* sight,
                            int* tracked) {
    const gsf_scene* scene = job->scene;
    const float* center = job->discs.all[i].center;
    const size_t row = job->discs.rows[i];
    double best = -2.0; // largest cosine, as cosine * |cosine| to avoid a square root per view
    *tracked = 0;
    for (size_t t = scene->track_begin[row]; t < scene->track_begin[row + 1]; t++) {
        const uint32_t view = scene->track_views[t];
        if (view == eye->view) { *tracked = 1; continue; }
        double along = 0.0, length2 = 0.0;
        for (int k = 0; k < 3; k++) {
            const double d = (double)center[k] - job->centers[3 * (size_t)view + (size_t)k];
            along += d * sight->direction[k];
            length2 += d * d;
        }
        const double cosine2 = along * fabs(along) / length2;
        if (cosine2 > best) best = cosine2;
    }
    if (best < -1.5) return -1.0f;
    best = best < 0.0 ? -sqrt(-best) : sqrt(best);
    return best < 1.0 ? (float)sqrt(2.0 - 2.0 * best) : 0.0f;
}

static int gsf__vis_bin(float apart) {
    const int bin = (int)(apart * 20.0f);
    return bin < GSF__VIS_BINS ? bin : GSF__VIS_BINS - 1;
}

// Computes the bounding box of each chunk, the directions from which each track sees its point, and how often tracks
// contain the eyes' views.
static void gsf__vis_survey_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const gsf_scene* scene = job->scene;
    gsf__vis_counts* counts = job->counts + chunk;
    const size_t first = chunk * GSF__VIS_CHUNK, count = job->discs.count;
    const size_t end = count - first < GSF__VIS_CHUNK ? count : first + GSF__VIS_CHUNK;
    gsf__vis_region(&job->discs, first, end, job->regions + 6 * chunk);
    if (!job->evidence) return;
    for (size_t i = first; i < end; i++) {
        const size_t row = job->discs.rows[i];
        double sum[3] = {0.0, 0.0, 0.0};
        for (size_t t = scene->track_begin[row]; t < scene->track_begin[row + 1]; t++) {
            const double* center = job->centers + 3 * (size_t)scene->track_views[t];
            double d[3], length2 = 0.0;
            for (int k = 0; k < 3; k++) {
                d[k] = (double)job->discs.all[i].center[k] - center[k];
                length2 += d[k] * d[k];
            }
            if (length2 > 0.0)
                for (int k = 0; k < 3; k++) sum[k] += d[k] / sqrt(length2);
        }
        for (int k = 0; k < 3; k++) job->facing[3 * i + (size_t)k] = (float)sum[k];
    }
    for (size_t e = 0; e < job->eye_count; e++) {
        if (gsf__vis_side(job->eyes + e, job->regions + 6 * chunk) < 0) continue;
        for (size_t i = first; i < end; i++) {
            gsf__sight sight;
            int tracked;
            if (!gsf__vis_sight(job, job->eyes + e, i, &sight)) continue;
            const float apart = gsf__vis_apart(job, job->eyes + e, i, &sight, &tracked);
            if (!(apart >= 0.0f)) continue;
            counts->tries[gsf__vis_bin(apart)]++;
            counts->finds[gsf__vis_bin(apart)] += (uint32_t)tracked;
        }
    }
}

// Turns each normal towards the views that see the point's neighbours, without regard to the point's own track.
static void gsf__vis_orient_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const gsf__discs* discs = &job->discs;
    const size_t first = chunk * GSF__VIS_CHUNK, near_count = (size_t)discs->near_count;
    for (size_t i = first; i < discs->count && i < first + GSF__VIS_CHUNK; i++) {
        float* normal = discs->all[i].normal;
        double along = 0.0;
        for (size_t n = 0; n < near_count; n++) {
            const float* facing = job->facing + 3 * (size_t)discs->nearest[near_count * i + n];
            for (int k = 0; k < 3; k++) along += (double)normal[k] * (double)facing[k];
        }
        discs->oriented[i] = fabs(along) > 0.0;
        if (along > 0.0)
            for (int k = 0; k < 3; k++) normal[k] = -normal[k];
    }
}

// Estimates the likelihoods. How often tracks contain a view, binned by gsf__vis_apart, is taken as the probability
// that the track of a visible point contains it. For a hidden point that probability is set to 0.03 (a wrong match, or
// a visible neighbour).
static void gsf__vis_likelihoods(gsf__vis_job* job) {
    const double wrong = 0.03;
    for (int b = 0; b < GSF__VIS_BINS; b++) {
        double tries = 0.0, finds = 0.0;
        for (size_t c = 0; c * GSF__VIS_CHUNK < job->discs.count; c++) {
            tries += job->counts[c].tries[b];
            finds += job->counts[c].finds[b];
        }
        double p = (finds + 1.0) / (tries + 20.0);
        p = p < 0.02 ? 0.02 : p > 0.95 ? 0.95 : p;
        job->found[b] = gsf__log_f64(p / wrong);
        job->missed[b] = gsf__log_f64((1.0 - p) / (1.0 - wrong));
    }
}

static void gsf__vis_evidence_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const size_t first = chunk * GSF__VIS_CHUNK;
    for (const gsf__look* look = job->looks; look < job->looks + job->look_count; look++) {
        const int outside = gsf__vis_side(look->eye, job->regions + 6 * chunk) < 0;
        for (size_t i = first; i < job->discs.count && i < first + GSF__VIS_CHUNK; i++) {
            gsf__sight sight;
            int tracked;
            look->apart[i] = -1.0f;
            look->evidence[i] = 0.0f;
            if (outside || !gsf__vis_sight(job, look->eye, i, &sight)) continue;
            look->apart[i] = gsf__vis_apart(job, look->eye, i, &sight, &tracked);
            if (!(look->apart[i] >= 0.0f)) continue;
            const int bin = gsf__vis_bin(look->apart[i]);
            look->evidence[i] = (float)(tracked ? job->found[bin] : job->missed[bin]);
        }
    }
}

// Returns the cover at which point i counts as hidden from an eye. The weights are a logistic fit on three ray-traced
// scenes, in units of desc->coverage; the constant term is tuned for the union over several views.
static float gsf__vis_limit(const gsf__vis_job* job, const gsf__look* look, size_t i) {
    const gsf__discs* discs = &job->discs;
    if (!look->evidence) return (float)(double)job->desc->coverage;
    const size_t near_count = (size_t)discs->near_count;
    const gsf__disc* disc = discs->all + i;
    const float* normal = disc->normal;
    double sum = 0.0, along = 0.0, length2 = 0.0, limit = 1.0;
    for (size_t n = 0; n < near_count; n++) { // weighted by how parallel the neighbour's disc is
        const size_t j = discs->nearest[near_count * i + n];
        const float* other = discs->all[j].normal;
        const double same = (double)(normal[0] * other[0] + normal[1] * other[1] + normal[2] * other[2]);
        sum += same * same * (double)look->evidence[j];
    }
    if (near_count) sum *= 12.0 / (double)near_count;
    limit += 0.095 * (sum < 12.0 ? sum : 12.0); // capped, as neighbours may be visible where the point is hidden
    if (look->apart[i] >= 0.0f) limit -= 0.15 + 0.85 * (double)(look->apart[i] < 1.0f ? look->apart[i] : 1.0f);
    for (int k = 0; k < 3; k++) {
        const double d = (double)disc->center[k] - look->eye->center[k];
        along += d * (double)normal[k];
        length2 += d * d;
    }
    if (discs->oriented[i] && along > 0.0) { // seen from behind
        const double back = along / sqrt(length2);
        limit -= 2.5 * (back < 0.5 ? back : 0.5);
    }
    return (float)((double)job->desc->coverage * limit);
}

// Prepares the looks of eye e and those after it, as many as are tested together.
static void gsf__vis_look(gsf_context* ctx, gsf__vis_job* job, size_t e) {
    for (job->look_count = 0; job->look_count < GSF__VIS_LOOKS && e < job->eye_count; e++) {
        const size_t from = job->discs.count * job->look_count;
        gsf__look* look = job->looks + job->look_count++;
        look->eye = job->eyes + e;
        look->apart = job->apart ? job->apart + from : NULL;
        look->evidence = job->evidence ? job->evidence + from : NULL;
    }
    if (job->evidence) gsf__vis_run(ctx, job, gsf__vis_evidence_chunk);
}

// A disc relative to an eye.
typedef struct gsf__vis_disc {
    double d[3], normal[3], plane, radius; // plane: distance of its plane from the eye, times the length of the normal
} gsf__vis_disc;

static gsf__vis_disc gsf__vis_disc_of(const gsf__vis_job* job, const gsf__eye* eye, size_t j) {
    const gsf__disc* of = job->discs.all + j;
    gsf__vis_disc disc;
    disc.plane = 0.0;
    disc.radius = (double)of->radius;
    for (int k = 0; k < 3; k++) {
        disc.d[k] = (double)of->center[k] - eye->center[k];
        disc.normal[k] = (double)of->normal[k];
        disc.plane += disc.d[k] * disc.normal[k];
    }
    return disc;
}

// Returns what a disc adds to the cover of the ray from the eye to a point with a disc of radius `own`. Used with Embree
// and without.
static inline double gsf__vis_cover(const gsf__vis_disc* disc, const gsf__sight* sight, double own, double tolerance) {
    const double *a = sight->direction, *n = disc->normal, *d = disc->d, radius = disc->radius;
    const double behind = tolerance * (own > radius ? own : radius);
    const double slope = a[0] * n[0] + a[1] * n[1] + a[2] * n[2];
    if (slope == 0.0) return 0.0;
    const double t = disc->plane / slope;
    if (!(t > 0.0 && sight->distance - t >= behind)) return 0.0;
    const double x = t * a[0] - d[0], y = t * a[1] - d[1], z = t * a[2] - d[2], q2 = x * x + y * y + z * z;
    return q2 < radius * radius ? 1.0 - q2 / (radius * radius) : 0.0;
}

// Computes the cells of [0,side) that the interval c - e .. c + e projects to at depths z0..z1 (both > 0). `scale` and
// `center` are in cells. The range is widened by 0.01 cells on both sides to be safe from rounding.
static void gsf__vis_span(double c, double e, double z0, double z1, double scale, double center, int32_t side,
                          int16_t* begin, int16_t* end) {
    const double lo = scale * (c - e) / (c - e < 0.0 ? z0 : z1) + center - 0.01;
    const double hi = scale * (c + e) / (c + e < 0.0 ? z1 : z0) + center + 0.01;
    *begin = (int16_t)(lo <= 0.0 ? 0 : lo >= side ? side : (int32_t)lo);
    *end = (int16_t)(hi < 0.0 ? 0 : hi >= side ? side : (int32_t)hi + 1);
}

// Computes the cell of every point that needs a ray, and the box of cells of every disc.
static void gsf__vis_project_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    gsf__vis_counts* counts = job->counts + chunk;
    const gsf__eye* eye = job->look->eye;
    const gsf_camera* camera = &eye->camera;
    const double *m = camera->w2c, sx = (double)job->side / (double)camera->width;
    const double sy = (double)job->side / (double)camera->height;
    const size_t first = chunk * GSF__VIS_CHUNK;
    gsf__disc_box* all = job->chunk_boxes + chunk;
    memset(all, 0, sizeof *all);
    all->y0 = (int16_t)job->side;
    for (size_t i = first; i < job->discs.count && i < first + GSF__VIS_CHUNK; i++) {
        job->cells[i] = -1;
        job->cover[i] = 0.0;
        if (!job->seen[i]) {
            if (gsf__vis_sight(job, eye, i, job->sights + i) &&
                (job->limits[i] = gsf__vis_limit(job, job->look, i)) > 0.0f) {
                const int32_t x = (int32_t)(job->sights[i].u * sx), y = (int32_t)(job->sights[i].v * sy);
                job->cells[i] = (y < job->side ? y : job->side - 1) * job->side + (x < job->side ? x : job->side - 1);
                counts->rays++;
            } else {
                counts->culled++;
            }
        }
        const gsf__disc* disc = job->discs.all + i;
        const float* normal = disc->normal;
        double d[3], c[3], e[3];
        for (int k = 0; k < 3; k++) d[k] = (double)disc->center[k] - eye->center[k];
        for (int r = 0; r < 3; r++) { // centre and half extent along the camera's axes
            const double n = m[r] * (double)normal[0] + m[4 + r] * (double)normal[1] + m[8 + r] * (double)normal[2];
            c[r] = m[r] * d[0] + m[4 + r] * d[1] + m[8 + r] * d[2];
            e[r] = (double)disc->radius * (sqrt(n * n < 1.0 ? 1.0 - n * n : 0.0) + 1e-6);
        }
        gsf__disc_box* box = job->boxes + i;
        box->x0 = box->x1 = box->y0 = box->y1 = 0;
        if (c[2] + e[2] <= 0.0) continue;
        if (c[2] - e[2] <= 1e-3 * (double)disc->radius) { // reaches behind the eye: may project anywhere
            box->x1 = box->y1 = all->y1 = (int16_t)job->side;
            all->y0 = 0;
            continue;
        }
        gsf__vis_span(c[0], e[0], c[2] - e[2], c[2] + e[2], camera->fx * sx, camera->cx * sx, job->side,
                      &box->x0, &box->x1);
        gsf__vis_span(c[1], e[1], c[2] - e[2], c[2] + e[2], camera->fy * sy, camera->cy * sy, job->side,
                      &box->y0, &box->y1);
        if (box->x0 < box->x1 && box->y0 < all->y0) all->y0 = box->y0;
        if (box->x0 < box->x1 && box->y1 > all->y1) all->y1 = box->y1;
    }
}

// Tests a band of rows of cells. Every point is tested against the discs in their order, so the sum of its cover does
// not depend on the number of workers.
static void gsf__vis_band_of_cells(void* arg, size_t band, int32_t worker) {
    (void)worker;
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const int32_t y0 = (int32_t)band * job->side / GSF__VIS_BANDS, y1 = ((int32_t)band + 1) * job->side / GSF__VIS_BANDS;
    const uint32_t first = job->cell_begin[y0 * job->side], last = job->cell_begin[y1 * job->side];
    if (first == last) return;
    const double tolerance = (double)job->desc->tolerance;
    for (size_t j = 0; j < job->discs.count; j++) {
        const gsf__disc_box *box = job->boxes + j, *chunk = job->chunk_boxes + j / GSF__VIS_CHUNK;
        if (chunk->y0 >= y1 || chunk->y1 <= y0) { // discs of a chunk are neighbours
            j = (j / GSF__VIS_CHUNK + 1) * GSF__VIS_CHUNK - 1;
            continue;
        }
        if (box->x0 >= box->x1 || box->y0 >= y1 || box->y1 <= y0) continue;
        const gsf__vis_disc disc = gsf__vis_disc_of(job, job->look->eye, j);
        for (int32_t y = box->y0 > y0 ? box->y0 : y0; y < box->y1 && y < y1; y++) {
            const uint32_t* row = job->cell_begin + y * job->side; // the points of a row of cells are contiguous
            for (uint32_t k = row[box->x0]; k < row[box->x1]; k++) {
                const uint32_t i = job->cell_points[k];
                if (i != j && job->cover[i] < (double)job->limits[i])
                    job->cover[i] += gsf__vis_cover(&disc, job->sights + i, (double)job->discs.all[i].radius, tolerance);
            }
        }
    }
    for (uint32_t k = first; k < last; k++)
        job->seen[job->cell_points[k]] = job->cover[job->cell_points[k]] < (double)job->limits[job->cell_points[k]];
}

// Ray tests without Embree: for each eye, tests every disc against the points in the cells that its projection touches.
static gsf_result gsf__vis_by_cells(gsf_context* ctx, gsf__vis_job* job) {
    const size_t n = job->discs.count, most = GSF__VIS_MAX_SIDE;
    job->side = GSF__VIS_BANDS;
    while ((size_t)job->side < most && 2 * (size_t)job->side * (size_t)job->side < n) job->side *= 2; // 2 points a cell
    const size_t cell_count = (size_t)job->side * (size_t)job->side;
    job->sights = (gsf__sight*)gsf__arena_alloc(&job->arena, n, sizeof(gsf__sight));
    job->cells = (int32_t*)gsf__arena_alloc(&job->arena, n, sizeof(int32_t));
    job->boxes = (gsf__disc_box*)gsf__arena_alloc(&job->arena, n, sizeof(gsf__disc_box));
    job->chunk_boxes = (gsf__disc_box*)gsf__arena_alloc(&job->arena, n / GSF__VIS_CHUNK + 1, sizeof(gsf__disc_box));
    job->limits = (float*)gsf__arena_alloc(&job->arena, n, sizeof(float));
    job->cover = (double*)gsf__arena_alloc(&job->arena, n, sizeof(double));
    job->cell_points = (uint32_t*)gsf__arena_alloc(&job->arena, n, sizeof(uint32_t));
    job->cell_begin = (uint32_t*)gsf__arena_alloc(&job->arena, cell_count + 2, sizeof(uint32_t));
    if (job->arena.failed) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t e = 0; e < job->eye_count; e++) {
        if (e % GSF__VIS_LOOKS == 0) gsf__vis_look(ctx, job, e);
        job->look = job->looks + e % GSF__VIS_LOOKS;
        gsf__vis_run(ctx, job, gsf__vis_project_chunk);
        // Counting sort: begin[c + 2] counts the points of cell c, then begin[c + 1] is its insertion point.
        uint32_t* begin = job->cell_begin;
        memset(begin, 0, (cell_count + 2) * sizeof(uint32_t));
        for (size_t i = 0; i < job->discs.count; i++)
            if (job->cells[i] >= 0) begin[job->cells[i] + 2]++;
        for (size_t c = 2; c < cell_count + 2; c++) begin[c] += begin[c - 1];
        for (size_t i = 0; i < job->discs.count; i++)
            if (job->cells[i] >= 0) job->cell_points[begin[job->cells[i] + 1]++] = (uint32_t)i;
        gsf__parallel_for(ctx, GSF__VIS_BANDS, gsf__vis_band_of_cells, job);
        GSF__TRY(gsf__check_cancel(ctx));
    }
    return GSF_OK;
}

#ifdef GSF_USE_EMBREE
static gsf_result gsf__vis_by_embree(gsf_context* ctx, gsf__vis_job* job, gsf_visibility_stats* stats);
#endif

static void gsf__vis_by_tracks(const gsf_scene* scene, const uint8_t* chosen, uint8_t* keep) {
    for (size_t i = 0; i < scene->point_count; i++)
        for (size_t t = scene->track_begin[i]; t < scene->track_begin[i + 1] && !keep[i]; t++)
            keep[i] = chosen[scene->track_views[t]];
}

// Prepares discs, eyes and the evidence from the tracks. Free job->arena, also after an error.
static gsf_result gsf__vis_begin(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                 const gsf_visibility_desc* desc, const uint8_t* keep, gsf__vis_job* job,
                                 gsf_visibility_stats* stats) {
    memset(job, 0, sizeof *job);
    job->arena.ctx = ctx;
    job->desc = desc;
    job->scene = scene;
    job->eyes = (gsf__eye*)gsf__arena_alloc(&job->arena, view_count, sizeof(gsf__eye));
    job->centers = (double*)gsf__arena_alloc(&job->arena, scene->view_count, 3 * sizeof(double));
    if (job->arena.failed) return GSF_ERROR_OUT_OF_MEMORY;
    job->eye_count = view_count;
    double origin[3] = {0.0, 0.0, 0.0};
    for (size_t i = 0; i < view_count; i++) {
        gsf__eye* eye = job->eyes + i;
        eye->camera = scene->views[views[i]].camera;
        gsf_get_camera_center(&eye->camera, eye->center);
        eye->view = views[i];
        for (int k = 0; k < 3; k++) origin[k] += eye->center[k] / (double)view_count;
    }
    for (size_t i = 0; i < view_count; i++)
        for (int k = 0; k < 3; k++) job->eyes[i].center[k] -= origin[k];
    for (size_t i = 0; i < scene->view_count; i++) {
        gsf_get_camera_center(&scene->views[i].camera, job->centers + 3 * i);
        for (int k = 0; k < 3; k++) job->centers[3 * i + (size_t)k] -= origin[k];
    }

    const double start = gsf__seconds();
    GSF__TRY(gsf__discs_make(&job->arena, scene, origin, desc, &job->discs));
    stats->seconds_normals = gsf__seconds() - start;
    const size_t n = job->discs.count, chunks = (n + GSF__VIS_CHUNK - 1) / GSF__VIS_CHUNK;
    job->seen = (uint8_t*)gsf__arena_alloc(&job->arena, n, 1);
    job->counts = (gsf__vis_counts*)gsf__arena_alloc_zeroed(&job->arena, chunks, sizeof *job->counts);
    job->regions = (float*)gsf__arena_alloc(&job->arena, chunks, 6 * sizeof(float));
    if (scene->track_begin && scene->track_begin[scene->point_count] > scene->track_begin[0]) {
        job->facing = (float*)gsf__arena_alloc(&job->arena, n, 3 * sizeof(float));
        job->apart = (float*)gsf__arena_alloc(&job->arena, n, GSF__VIS_LOOKS * sizeof(float));
        job->evidence = (float*)gsf__arena_alloc(&job->arena, n, GSF__VIS_LOOKS * sizeof(float));
    }
    if (job->arena.failed) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < job->discs.count; i++) job->seen[i] = keep[job->discs.rows[i]];
    gsf__vis_run(ctx, job, gsf__vis_survey_chunk);
    if (job->evidence) {
        gsf__vis_run(ctx, job, gsf__vis_orient_chunk);
        gsf__vis_likelihoods(job);
    }
    return GSF_OK;
}

static gsf_result gsf__vis_by_rays(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                   const gsf_visibility_desc* desc, uint8_t* keep, gsf_visibility_stats* stats) {
    gsf__vis_job job;
    const double start = gsf__seconds();
    gsf_result result = gsf__vis_begin(ctx, scene, views, view_count, desc, keep, &job, stats);
#ifdef GSF_USE_EMBREE
    if (result == GSF_OK && !desc->use_zbuffer) result = gsf__vis_by_embree(ctx, &job, stats);
#endif
    if (result == GSF_OK && !stats->used_embree) result = gsf__vis_by_cells(ctx, &job);
    if (result == GSF_OK) {
        stats->seconds_rays = gsf__seconds() - start - stats->seconds_normals - stats->seconds_build;
        for (size_t i = 0; i * GSF__VIS_CHUNK < job.discs.count; i++) {
            stats->rays += job.counts[i].rays;
            stats->culled += job.counts[i].culled;
        }
        for (size_t i = 0; i < job.discs.count; i++) {
            stats->by_rays += job.seen[i] && !keep[job.discs.rows[i]];
            keep[job.discs.rows[i]] = job.seen[i];
        }
        if (job.discs.count < scene->point_count)
            gsf_log(ctx, GSF_LOG_WARNING, "visible points: %zu points with a non-finite coordinate are not traced",
                    scene->point_count - job.discs.count);
    }
    gsf__arena_free(&job.arena);
    return result;
}

GSF_API gsf_result gsf_splat_filter_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
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

/* In a dense cloud most points are hidden from most views, neighbouring points are hidden by the same discs, and so is a
   point from the next view. So groups of sixteen neighbouring points are first tested, in float with bounds on all rounding
   errors, against the discs that hid the group before and those that hid this one from the previous eye, then against the
   neighbours of the discs that cover a point. Only points that these tests do not prove hidden are traced with Embree. Every
   chunk of points is tested for several eyes in turn, so that the discs stay in the cache. */
enum { GSF__VIS_GROUP = 16, GSF__VIS_GROUPS = GSF__VIS_CHUNK / GSF__VIS_GROUP, GSF__VIS_HIDERS = 32, GSF__VIS_QUEUE = 128 };

struct gsf__rays { // from an eye to a group of points
    GSF__LINES float direction[3][GSF__VIS_GROUP];
    float distance[GSF__VIS_GROUP];
    float error[GSF__VIS_GROUP]; // ten times a bound of that of a distance along the ray, times a slope
    float own[GSF__VIS_GROUP];   // tolerance times the radius of the point's own disc
    float cover[GSF__VIS_GROUP]; // lower bound of the cover so far
    float need[GSF__VIS_GROUP];  // cover at which the point is hidden
    float eye[3], rest[3];       // the eye is at the sum of these
    float tolerance;
};

struct gsf__unseen { // the points of a chunk that no eye before has seen, in groups
    int count;
    float center[3][GSF__VIS_CHUNK], normal[3][GSF__VIS_CHUNK];
    float own[GSF__VIS_CHUNK]; // as in gsf__rays
    uint32_t points[GSF__VIS_CHUNK];
};

struct gsf__hiders { // discs that may hide points, in the order in which they are tested
    int count, next;                  // next: the first that was not tested
    uint32_t discs[GSF__VIS_QUEUE + 1];
    uint16_t covered[GSF__VIS_QUEUE]; // bits: rays of the group that it covers, of those that were open
    uint64_t queued[16];              // bit set of the discs, by disc modulo 1024
};

#define GSF__KERNELS "gsfixer_splat.h"
#define GSF__KERNELS_HIDE
#define GSF__KERNELS_AVX512
#define GSF__KERNELS_SIMD128
#include "gsfixer.h"
#undef GSF__KERNELS_HIDE
#endif // GSF_USE_EMBREE

#endif // GSF__ISA
#ifdef GSF__KERNELS_HIDE

// Aims the rays at the group of points from `first` on, and returns those (bits) that meet their discs at an angle whose
// cosine is above `grazing`.
GSF__V_KERNEL uint32_t GSF__V(gsf__aim)(const gsf__unseen* unseen, int first, float grazing, gsf__rays* rays) {
    uint32_t clear = 0;
    for (int l = 0; l < GSF__VIS_GROUP; l += GSF__LANES) {
        gsf__vf d[3], along = gsf__v_set(0.0f), length2 = along;
        for (int k = 0; k < 3; k++) { // as precise as if it were rounded from double
            d[k] = (gsf__v_load(unseen->center[k] + first + l) - gsf__v_set(rays->eye[k])) - gsf__v_set(rays->rest[k]);
            along = gsf__v_madd(d[k], gsf__v_load(unseen->normal[k] + first + l), along);
            length2 = gsf__v_madd(d[k], d[k], length2);
        }
        const gsf__vf distance = gsf__v_sqrt(length2), inverse = gsf__v_set(1.0f) / distance;
        for (int k = 0; k < 3; k++) gsf__v_store(rays->direction[k] + l, d[k] * inverse);
        gsf__v_store(rays->distance + l, distance);
        gsf__v_store(rays->error + l, gsf__v_set(1e-5f) * distance);
        gsf__v_store(rays->own + l, gsf__v_load(unseen->own + first + l));
        gsf__v_store(rays->cover + l, gsf__v_set(0.0f));
        clear |= gsf__vm_bits(gsf__v_gt(gsf__v_abs(along) * inverse, gsf__v_set(grazing))) << l;
    }
    return clear;
}

// Adds lower bounds of the discs' cover to the rays, disc by disc, until none of the rays `open` (bits) remains that is not
// proved hidden. Returns those that remain.
GSF__V_KERNEL uint32_t GSF__V(gsf__hide)(const gsf__disc* discs, gsf__rays* rays, gsf__hiders* hiders, uint32_t open) {
    const gsf__vf one = gsf__v_set(1.0f), zero = gsf__v_set(0.0f);
    for (; open && hiders->next < hiders->count; hiders->next++) {
        const gsf__disc* disc = discs + hiders->discs[hiders->next];
        const float* n = disc->normal;
        const float cx = (disc->center[0] - rays->eye[0]) - rays->rest[0];
        const float cy = (disc->center[1] - rays->eye[1]) - rays->rest[1];
        const float cz = (disc->center[2] - rays->eye[2]) - rays->rest[2];
        const float plane = cx * n[0] + cy * n[1] + cz * n[2], reach = rays->tolerance * disc->radius;
        uint32_t covered = 0, left = 0;
        for (int l = 0; l < GSF__VIS_GROUP; l += GSF__LANES) {
            const gsf__vf distance = gsf__v_load(rays->distance + l), x = gsf__v_load(rays->direction[0] + l);
            const gsf__vf y = gsf__v_load(rays->direction[1] + l), z = gsf__v_load(rays->direction[2] + l);
            const gsf__vf slope = gsf__v_madd(x, gsf__v_set(n[0]), gsf__v_madd(y, gsf__v_set(n[1]), z * gsf__v_set(n[2])));
            const gsf__vf inverse = one / slope, t = gsf__v_set(plane) * inverse;
            const gsf__vf error = gsf__v_load(rays->error + l) * gsf__v_abs(inverse); // ten times that of t and of the crossing
            const gsf__vf gap = distance - gsf__v_max(gsf__v_load(rays->own + l), gsf__v_set(reach)) - t;
            const gsf__vf qx = gsf__v_msub(t, x, gsf__v_set(cx)), qy = gsf__v_msub(t, y, gsf__v_set(cy));
            const gsf__vf qz = gsf__v_msub(t, z, gsf__v_set(cz));
            // (q + e)^2 <= 1.01 (q^2 + 100 e^2) for the distance q of the crossing from the disc's centre
            const gsf__vf q2 = gsf__v_madd(qx, qx, gsf__v_madd(qy, qy, gsf__v_madd(qz, qz, error * error)));
            const gsf__vf cover = gsf__v_nmadd(q2, gsf__v_set(1.01f * disc->inverse2), one);
            const gsf__vm hit = gsf__vm_and(gsf__v_gt(t, error), gsf__vm_and(gsf__v_gt(gap, error), gsf__v_gt(cover, zero)));
            const gsf__vf sum = gsf__v_load(rays->cover + l) + gsf__v_keep(hit, cover);
            gsf__v_store(rays->cover + l, sum);
            covered |= gsf__vm_bits(hit) << l;
            left |= gsf__vm_bits(gsf__v_lt(sum, gsf__v_load(rays->need + l))) << l;
        }
        hiders->covered[hiders->next] = (uint16_t)(covered & open);
        open &= left;
    }
    return open;
}

#endif // GSF__KERNELS_HIDE
#ifndef GSF__ISA
#ifdef GSF_USE_EMBREE

typedef struct gsf__embree_query { // starts with Embree's context, whose address Embree passes to the filter
#if RTC_VERSION_MAJOR < 4
    struct RTCIntersectContext context;
#else
    struct RTCRayQueryContext context;
#endif
    const gsf__vis_job* job;
    const gsf__look* look;
    // the current ray
    gsf__sight sight;
    size_t point;
    double cover, limit;  // cover of the discs hit so far; cover at which the point is hidden
    gsf__unseen* unseen;  // of the chunk
    // the current group
    gsf__rays rays;
    gsf__hiders hiders;   // starts with discs that covered points of the previous group
    // of each group, some of the discs that covered points of it from the last eye
    int found_count[GSF__VIS_GROUPS];
    uint32_t found[GSF__VIS_GROUPS][GSF__VIS_HIDERS];
} gsf__embree_query;

// Without branches: whether a disc is queued already is hard to predict.
static void gsf__hiders_add(gsf__hiders* h, const gsf__discs* discs, uint32_t disc) {
    uint64_t* word = h->queued + (disc >> 6 & 15u);
    const int is_new = !(*word >> (disc & 63u) & 1u) & (h->count < GSF__VIS_QUEUE);
    gsf__v_fetch_scalar(discs->all[disc].center);
    h->discs[h->count] = disc;
    h->count += is_new;
    *word |= (uint64_t)1 << (disc & 63u);
}

// Embree calls this for every disc that the ray hits, in no particular order. Rejecting the hit continues the
// traversal; it is accepted once the cover reaches the limit.
static void gsf__embree_filter(const struct RTCFilterFunctionNArguments* args) {
    gsf__embree_query* q = (gsf__embree_query*)(void*)args->context;
    const struct RTCHit* hit = (const struct RTCHit*)(const void*)args->hit; // single rays only: N is 1
    if (args->valid[0] == 0) return;
    if (hit->primID == q->point) { // with tolerance 0, the ray may reach the point's own disc
        args->valid[0] = 0;
        return;
    }
    const gsf__discs* discs = &q->job->discs;
    const gsf__vis_disc disc = gsf__vis_disc_of(q->job, q->look->eye, hit->primID);
    const double own = (double)discs->all[q->point].radius;
    const double cover = gsf__vis_cover(&disc, &q->sight, own, (double)q->job->desc->tolerance);
    q->cover += cover;
    if (q->cover < q->limit) args->valid[0] = 0;
    if (cover > 0.0) gsf__hiders_add(&q->hiders, discs, hit->primID);
}

static void gsf__embree_ray(gsf__embree_query* q, size_t i) {
    const gsf__vis_job* job = q->job;
    const gsf__eye* eye = q->look->eye;
    if (!gsf__vis_sight(job, eye, i, &q->sight)) return;
    q->point = i;
    q->cover = 0.0;
    q->limit = (double)gsf__vis_limit(job, q->look, i);
    // The ray starts at the eye and ends `tolerance` short of the point. (Starting at the point would depend on Embree's
    // version: some report a disc that contains the origin, others do not.)
    const double reach = q->sight.distance - (double)(job->desc->tolerance * job->discs.all[i].radius);
    if (reach > 0.0) {
        struct RTCRay ray;
        memset(&ray, 0, sizeof ray);
        ray.org_x = (float)eye->center[0];
        ray.org_y = (float)eye->center[1];
        ray.org_z = (float)eye->center[2];
        ray.dir_x = (float)q->sight.direction[0];
        ray.dir_y = (float)q->sight.direction[1];
        ray.dir_z = (float)q->sight.direction[2];
        ray.tfar = (float)reach;
        ray.mask = 0xffffffffu;
#if RTC_VERSION_MAJOR < 4
        rtcOccluded1((RTCScene)job->embree_scene, &q->context, &ray);
#else
        struct RTCOccludedArguments args;
        rtcInitOccludedArguments(&args);
        args.context = &q->context;
        rtcOccluded1((RTCScene)job->embree_scene, &ray, &args);
#endif
    }
    job->seen[i] = q->cover < q->limit;
}

// Tests the rays against the queued discs, and then against the neighbours of discs that cover an open ray. `open`: bits of
// the rays not yet proved hidden; returns those that remain. *expanded: the first disc whose neighbours are not queued yet.
static uint32_t gsf__embree_meet(gsf__embree_query* q, int* expanded, uint32_t open) {
    const gsf__discs* discs = &q->job->discs;
    gsf__hiders* h = &q->hiders;
    for (;;) {
        open = q->job->hide(discs->all, &q->rays, h, open);
        if (!open) return 0;
        while (*expanded < h->next && !(h->covered[*expanded] & open)) (*expanded)++;
        if (*expanded == h->next) return open;
        const uint32_t* nearest = discs->nearest + (size_t)discs->near_count * h->discs[(*expanded)++];
        for (int n = 0; n < discs->near_count; n++) gsf__hiders_add(h, discs, nearest[n]);
    }
}

// Tests the points of the group from `first` on whose bits are set.
static void gsf__embree_group(gsf__embree_query* q, int first, uint32_t open, gsf__vis_counts* counts) {
    gsf__hiders* h = &q->hiders;
    uint32_t* found = q->found[first / GSF__VIS_GROUP];
    int* found_count = q->found_count + first / GSF__VIS_GROUP;
    for (int k = 0; k < *found_count; k++) gsf__hiders_add(h, &q->job->discs, found[k]);
    int expanded = 0, useful = 0;
    open = gsf__embree_meet(q, &expanded, open);
    while (open) {
        const int l = gsf__lowest_bit(open);
        counts->rays++;
        counts->culled--;
        gsf__embree_ray(q, q->unseen->points[first + l]);
        open = gsf__embree_meet(q, &expanded, open & (open - 1)); // discs that the ray found may hide the others
    }
    for (int k = 0; k < h->next && useful < GSF__VIS_HIDERS; k++) {
        found[useful] = h->discs[k];
        useful += h->covered[k] != 0;
    }
    *found_count = useful;
    h->count = h->next = 0;
    memset(h->queued, 0, sizeof h->queued);
    for (int k = 0; k < useful; k++) gsf__hiders_add(h, &q->job->discs, found[k]);
}

// Tests the chunk's points that no eye has seen yet for one eye.
static void gsf__embree_look(gsf__embree_query* q, const gsf__look* look, size_t chunk, gsf__vis_counts* counts) {
    const gsf__vis_job* job = q->job;
    const int side = gsf__vis_side(look->eye, job->regions + 6 * chunk);
    const float grazing = job->desc->min_grazing_cos + 1e-5f;
    q->look = look;
    q->hiders.count = 0;
    memset(q->hiders.queued, 0, sizeof q->hiders.queued);
    for (int k = 0; k < 3; k++) {
        q->rays.eye[k] = (float)look->eye->center[k];
        q->rays.rest[k] = (float)(look->eye->center[k] - (double)q->rays.eye[k]);
    }
    for (int first = 0; first < q->unseen->count; first += GSF__VIS_GROUP) {
        const uint32_t clear = job->aim(q->unseen, first, grazing, &q->rays);
        uint32_t open = 0;
        for (int l = 0; l < GSF__VIS_GROUP && first + l < q->unseen->count; l++) {
            const size_t i = q->unseen->points[first + l];
            if (job->seen[i]) continue;
            const int in_frame = side > 0 && (clear >> l & 1u); // otherwise gsf__vis_sight decides in double
            float limit = 0.0f;
            if (in_frame || (side >= 0 && gsf__vis_sight(job, look->eye, i, &q->sight))) limit = gsf__vis_limit(job, look, i);
            q->rays.need[l] = limit * 1.00001f;
            open |= (uint32_t)(limit > 0.0f) << l;
            counts->culled++;
        }
        if (open) gsf__embree_group(q, first, open, counts);
    }
}

static void gsf__vis_embree_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__vis_job* job = (const gsf__vis_job*)arg;
    const size_t first = chunk * GSF__VIS_CHUNK;
    gsf__unseen* unseen = job->unseen + worker;
    gsf__embree_query query;
    memset(&query, 0, sizeof query);
    query.job = job;
    query.unseen = unseen;
    query.rays.tolerance = job->desc->tolerance;
#if RTC_VERSION_MAJOR < 4
    rtcInitIntersectContext(&query.context);
#else
    rtcInitRayQueryContext(&query.context);
#endif
    unseen->count = 0;
    for (size_t i = first; i < job->discs.count && i < first + GSF__VIS_CHUNK; i++) {
        if (job->seen[i]) continue;
        const gsf__disc* disc = job->discs.all + i;
        const int at = unseen->count++;
        for (int k = 0; k < 3; k++) {
            unseen->center[k][at] = disc->center[k];
            unseen->normal[k][at] = disc->normal[k];
        }
        unseen->own[at] = job->desc->tolerance * disc->radius;
        unseen->points[at] = (uint32_t)i;
    }
    for (size_t k = 0; k < job->look_count; k++) gsf__embree_look(&query, job->looks + k, chunk, job->counts + chunk);
}

// Running out of memory inside Embree or TBB does not always end in an error code: a C++ exception that reaches a
// destructor or an error handler terminates the program. So Embree's allocations are already refused while this much
// memory is left.
enum { GSF__EMBREE_MARGIN = 16 << 20 };

// Returns whether `bytes` could be allocated. Probes malloc, since Embree does not use the context's allocator either.
static int gsf__embree_has_room(size_t bytes) {
    void* volatile probe = malloc(bytes); // volatile, or the compiler may assume success
    const int room = probe != NULL;
    free(probe);
    return room;
}

// Embree's memory monitor, which may refuse allocations. It runs on the calling thread, the only one of the device.
static bool gsf__embree_may_allocate(void* refused, ssize_t bytes, bool post) {
    if (bytes <= 0 || gsf__embree_has_room((post ? 0 : (size_t)bytes) + GSF__EMBREE_MARGIN)) return true;
    *(int*)refused = 1;
    return false;
}

static enum RTCError gsf__embree_build(RTCDevice device, RTCScene scene, const gsf__vis_job* job) {
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_ORIENTED_DISC_POINT);
    if (geometry) {
        rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT4, job->discs.all, 0,
                                   sizeof(gsf__disc), job->discs.count);
        rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_NORMAL, 0, RTC_FORMAT_FLOAT3, job->discs.all,
                                   offsetof(gsf__disc, normal), sizeof(gsf__disc), job->discs.count);
        rtcSetGeometryOccludedFilterFunction(geometry, gsf__embree_filter);
        rtcCommitGeometry(geometry);
        rtcAttachGeometry(scene, geometry);
        rtcReleaseGeometry(geometry); // the scene keeps a reference
        rtcCommitScene(scene);
    }
    return rtcGetDeviceError(device);
}

static gsf_result gsf__embree_run(gsf_context* ctx, gsf__vis_job* job) {
    gsf_result result = GSF_OK;
    job->unseen = (gsf__unseen*)gsf__arena_alloc_zeroed(&job->arena, (size_t)ctx->parallel.worker_count, sizeof(gsf__unseen));
    if (!job->unseen) return GSF_ERROR_OUT_OF_MEMORY;
    job->aim = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__aim);
    job->hide = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__hide);
    for (size_t e = 0; result == GSF_OK && e < job->eye_count; e += GSF__VIS_LOOKS) {
        gsf__vis_look(ctx, job, e);
        gsf__vis_run(ctx, job, gsf__vis_embree_chunk);
        result = gsf__check_cancel(ctx);
    }
    return result;
}

// If Embree fails, logs a warning and leaves stats->used_embree 0.
static gsf_result gsf__vis_by_embree(gsf_context* ctx, gsf__vis_job* job, gsf_visibility_stats* stats) {
    const double start = gsf__seconds();
    int refused = 0;
    gsf_result result = GSF_OK;
    RTCScene scene = NULL;
    RTCDevice device = NULL;
    enum RTCError error = RTC_ERROR_OUT_OF_MEMORY;
    if (gsf__embree_has_room(2 * (size_t)GSF__EMBREE_MARGIN)) {
        device = rtcNewDevice("threads=1,set_affinity=0"); // for the build; rays use the host's threads
        error = rtcGetDeviceError(device);
    }
    if (device) {
        rtcSetDeviceMemoryMonitorFunction(device, gsf__embree_may_allocate, &refused);
        scene = rtcNewScene(device);
        error = scene ? gsf__embree_build(device, scene, job) : rtcGetDeviceError(device);
    }
    if (device && error == RTC_ERROR_NONE) {
        stats->used_embree = 1;
        stats->seconds_build = gsf__seconds() - start;
        job->embree_scene = scene;
        result = gsf__embree_run(ctx, job);
    } else
        gsf_log(ctx, GSF_LOG_WARNING, "visible points: Embree cannot build %zu discs (%s); they are projected instead",
                job->discs.count, error == RTC_ERROR_OUT_OF_MEMORY ? "too little memory" : "no usable device");
    // A build that failed on its own may have left a TBB task that never runs; releasing the scene would wait for it.
    if (scene && (error == RTC_ERROR_NONE || refused)) rtcReleaseScene(scene);
    if (device) rtcReleaseDevice(device);
    return result;
}

#endif // GSF_USE_EMBREE

// ---- >>stereo ------------------------------------------------------------------

/* PatchMatch stereo after Zheng et al. 2014 and Schoenberger et al. 2016 (COLMAP), Galliani et al. 2015 (Gipuma:
   red-black propagation) and Xu and Tao 2019 (ACMH: eight propagation regions, source views weighted per pixel,
   geometric consistency). A plane is stored as inverse depth, an affine function of the pixel: 1/z = w + gx dx + gy dy.
   A pixel (x,y) then maps to another view by (X,Y,Z) = M (x,y,1) + t (1/z), so computing the homography of a window
   takes nine multiply-adds.

       prepare   scale photos to the working sizes (each texel of a channel packed with its 2x2 neighbours in one word);
                 choose the source views of every view
       match     per level, coarse to fine: initial planes, then iterations of (red pixels, black pixels)
       fuse      keep pixels that pass the consistency checks in other views; thin them out by marking the pixels
                 around every point taken

   Work is split into blocks of rows across all views. A red pixel reads the planes of black pixels only, and vice
   versa, so the result depends neither on the order of the blocks nor on the number of workers. Pixel centres are at
   integers here. */

enum {
    GSF__DENSE_SOURCES = 8,
    GSF__DENSE_SAMPLES = 256,
    GSF__DENSE_ROWS = 4,       // rows per chunk
    GSF__DENSE_PLANES = 9,     // candidates: the pixel's own plane and one from each of eight regions
    GSF__DENSE_MIN_SIDE = 40,  // minimum width and height of a photo, pixels
    GSF__DENSE_COARSEST = 48,  // the same of a coarser level: windows of fewer pixels show too little
};

#define GSF__DENSE_BAD 2.0f        // cost of a plane that cannot be evaluated
#define GSF__DENSE_MIN_VARIANCE 2.0f // grey levels squared; anything below is noise
#define GSF__DENSE_MIN_COS 0.15f   // between plane normal and viewing ray

typedef struct gsf__dense_plane { float w, gx, gy, cost; } gsf__dense_plane;

typedef struct gsf__dense_source { // another view and the mapping of pixels to it
    int32_t view;            // index into gsf__dense_job.views
    float m[9], t[3];        // M (row-major) and t; the inverse depth in the other view is w / Z
    float back_m[9], back_t[3]; // the mapping from the other view to this one
    float rotation[9];       // from this camera's axes to the other's
} gsf__dense_source;

typedef struct gsf__dense_view {
    uint32_t index;          // into the scene's views
    int32_t width, height;   // at this level
    gsf_camera camera;       // at this level
    float fx, fy, cx, cy;    // of `camera`, for pixel centres at integers
    gsf_image color;         // u8 RGB
    gsf_image weight;        // u8; data is NULL if all pixels count fully
    size_t first;            // index of the view's first pixel in the level's arrays
    int32_t source_count;
    gsf__dense_source sources[GSF__DENSE_SOURCES];
    float w_min, w_max;      // range of inverse depth
} gsf__dense_view;

typedef struct gsf__dense_window { // samples of the matching window, padded with zero-weight samples to a multiple of 8
    int32_t count;
    float dx[GSF__DENSE_SAMPLES], dy[GSF__DENSE_SAMPLES];
    float spatial[GSF__DENSE_SAMPLES];
    float tonal[256];        // weight by absolute grey difference from the window's centre
} gsf__dense_window;

typedef struct gsf__dense_patch { // the window around one pixel of the reference
    float weight[GSF__DENSE_SAMPLES], value[3][GSF__DENSE_SAMPLES]; // value: of each channel, minus center
    float center[3], weight_sum;
} gsf__dense_patch;

typedef struct gsf__dense_warp { // homography of a window: (X,Y,Z) at its centre, and its change per pixel in x and y
    float middle[3], along_x[3], along_y[3];
    const uint32_t* texels;  // of the first channel that is matched
    size_t stride;           // texels between channels
    int32_t width, height;
} gsf__dense_warp;

// Matching cost, 0..2: 1 - normalised cross-correlation between a patch and the other photo sampled through a warp. With
// colours, covariance and variances are sums over the channels, and a difference of the windows' mean colours is added.
typedef float (*gsf__dense_cost_fn)(const gsf__dense_window* window, const gsf__dense_patch* patch,
                                    const gsf__dense_warp* warp);

typedef struct gsf__dense_block { uint32_t view; int32_t row; } gsf__dense_block;

typedef struct gsf__dense_job gsf__dense_job;
typedef void (*gsf__dense_pixel_fn)(const gsf__dense_job* job, const gsf__dense_view* view, int x, int y);

struct gsf__dense_job {
    gsf_context* ctx;
    gsf__arena level_arena;        // the arrays of the level, except its planes, which the finer level starts from
    const gsf_scene* scene;
    gsf_dense_desc desc;
    const uint8_t* keep;
    gsf__dense_cost_fn cost_fns[2]; // of grey, of colours
    gsf__dense_window window;
    size_t view_count;
    gsf__dense_view* views;
    size_t pixel_count;            // of all views at this level
    int channels;                  // that are matched: 3 (red, green, blue) at coarse levels, 1 (grey) at the finest
    uint32_t* texels;              // (1,pixels) grey or (4,pixels) grey, red, green, blue
    gsf__dense_plane* planes;
    gsf__dense_plane* others;      // copy of the planes before a geometric iteration, NULL in other iterations
    float* source_costs;           // (pixels,GSF__DENSE_SOURCES)
    uint8_t* links;                // per pixel: bit s is set if source s confirms it; 0 if too few sources do
    size_t block_count;
    gsf__dense_block* blocks;
    // the coarser level, while its planes are upsampled
    gsf__dense_view* coarse_views;
    gsf__dense_plane* coarse_planes;
    float* seeds;                  // coarsest level: inverse depth of the nearest sparse point, 0 = none
    int32_t level, iteration, color;
    float step_pixels, step_normal; // size of the perturbations: depth, in source-view pixels; unit normal
    float min_normal_dot;          // minimum dot product of normals that count as consistent
    int32_t roam;                  // also try random planes from the whole depth range
    gsf__dense_pixel_fn pixel_fn;  // of gsf__dense_run
};

static void gsf__dense_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__dense_job* job = (const gsf__dense_job*)arg;
    const gsf__dense_view* view = job->views + job->blocks[chunk].view;
    const int first = job->blocks[chunk].row;
    for (int y = first; y < view->height && y < first + GSF__DENSE_ROWS; y++)
        for (int x = 0; x < view->width; x++) job->pixel_fn(job, view, x, y);
}

static void gsf__dense_run(gsf__dense_job* job, gsf__dense_pixel_fn pixel_fn) { // for all pixels of all views
    job->pixel_fn = pixel_fn;
    gsf__parallel_for(job->ctx, job->block_count, gsf__dense_chunk, job);
}

static gsf_dense_desc gsf__dense_desc_defaults(const gsf_dense_desc* desc) {
    gsf_dense_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.max_size == 0) d.max_size = 640;
    if (d.levels == 0) d.levels = 3;
    if (d.iterations == 0) d.iterations = 2;
    if (d.sources == 0) d.sources = 4;
    if (d.radius == 0) d.radius = 5;
    if (d.stride == 0) d.stride = 2;
    if (d.color_sigma == 0.0f) d.color_sigma = 18.0f;
    d.min_angle = gsf__or_zero(d.min_angle, 1.0f);
    if (d.max_cost == 0.0f) d.max_cost = 0.35f;
    if (d.max_cost_many == 0.0f) d.max_cost_many = 0.5f;
    if (d.max_cost_many < d.max_cost) d.max_cost_many = d.max_cost;
    if (d.max_reprojection == 0.0f) d.max_reprojection = 1.0f;
    if (d.max_depth_error == 0.0f) d.max_depth_error = 0.02f;
    if (d.max_normal_angle == 0.0f) d.max_normal_angle = 40.0f;
    if (d.min_consistent == 0) d.min_consistent = 1;
    if (d.spacing == 0) d.spacing = 2;
    return d;
}

static gsf_result gsf__dense_check(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                   const gsf_dense_desc* d) {
    const gsf__field fields[] = {
        {"max_size", (double)d->max_size, GSF__DENSE_MIN_SIDE, 16384},
        {"levels", (double)d->levels, 1, 8},
        {"iterations", (double)d->iterations, 1, 100},
        {"sources", (double)d->sources, 1, GSF__DENSE_SOURCES},
        {"radius", (double)d->radius, 1, 15},
        {"stride", (double)d->stride, 1, (double)d->radius},
        {"min_consistent", (double)d->min_consistent, 1, 1e9},
        {"spacing", (double)d->spacing, 1, 1024},
        {"color_sigma", (double)d->color_sigma, FLT_MIN, INFINITY},
        {"min_angle", (double)d->min_angle, 0, INFINITY},
        {"max_cost", (double)d->max_cost, FLT_MIN, 1.999},
        {"max_cost_many", (double)d->max_cost_many, 0, 1.999}, // GSF__DENSE_BAD is 2
        {"max_reprojection", (double)d->max_reprojection, FLT_MIN, INFINITY},
        {"max_depth_error", (double)d->max_depth_error, FLT_MIN, INFINITY},
        {"max_normal_angle", (double)d->max_normal_angle, FLT_MIN, 180},
    };
    GSF__TRY(gsf__check_fields(ctx, "dense points", fields, GSF__COUNT(fields)));
    const int side = 2 * (d->radius / d->stride) + 1;
    if (side * side > GSF__DENSE_SAMPLES)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "dense points: radius %d with stride %d needs more than %d samples", (int)d->radius,
                        (int)d->stride, (int)GSF__DENSE_SAMPLES);
    if (!(d->depth_min >= 0.0 && isfinite(d->depth_max) && (d->depth_max == 0.0 || d->depth_max > d->depth_min)))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dense points: invalid depth range %g to %g", d->depth_min,
                        d->depth_max);
    GSF__TRY(gsf__check_views(ctx, "dense points", scene, views, view_count));
    for (size_t i = 0; i < view_count; i++) {
        const gsf_scene_view* view = &scene->views[views[i]];
        if (!view->image.data)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dense points: the photo of view %u is not loaded",
                            (unsigned)views[i]);
        if (view->image.width != view->camera.width || view->image.height != view->camera.height)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dense points: view %u: photo %lld x %lld, camera %d x %d",
                            (unsigned)views[i], (long long)view->image.width, (long long)view->image.height,
                            (int)view->camera.width, (int)view->camera.height);
        const gsf_image* weight = &view->weight;
        if (weight->data && (weight->dtype != GSF_U8 || weight->channels != 1 || weight->width != view->image.width ||
                             weight->height != view->image.height))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "dense points: view %u: weight must be u8, one channel, %d x %d",
                            (unsigned)views[i], (int)view->camera.width, (int)view->camera.height);
    }
    return GSF_OK;
}

// ---- matching cost

enum { // weighted sums over a window: weight; squares in the reference and in the other photo, products, over all channels
    GSF__DENSE_W, GSF__DENSE_RR, GSF__DENSE_SS, GSF__DENSE_RS,
    GSF__DENSE_R, GSF__DENSE_S, // of the first channel's values in the reference and in the other photo; others follow
    GSF__DENSE_SUMS = 16,
};

#define GSF__DENSE_TINT 0.15f       // most that a difference of mean colours adds to the cost,
#define GSF__DENSE_TINT_RANGE 40.0f // from this many grey levels on

static float gsf__dense_correlate(const gsf__dense_patch* patch, const float* sums, int channels) {
    if (!(sums[GSF__DENSE_W] > 0.5f * patch->weight_sum)) return GSF__DENSE_BAD; // at least half of the weight is outside
    const float inv = 1.0f / sums[GSF__DENSE_W], least = GSF__DENSE_MIN_VARIANCE * (float)channels;
    float var_r = sums[GSF__DENSE_RR] * inv, var_s = sums[GSF__DENSE_SS] * inv, both = sums[GSF__DENSE_RS] * inv, tint = 0.0f;
    for (int c = 0; c < channels; c++) {
        const float mean_r = sums[GSF__DENSE_R + 2 * c] * inv, mean_s = sums[GSF__DENSE_S + 2 * c] * inv;
        var_r -= mean_r * mean_r;
        var_s -= mean_s * mean_s;
        both -= mean_r * mean_s;
        tint += fabsf(mean_r - mean_s);
    }
    if (!(var_r > least && var_s > least)) return GSF__DENSE_BAD;
    float cost = 1.0f - both / sqrtf(var_r * var_s);
    if (channels > 1) {
        tint *= 1.0f / (GSF__DENSE_TINT_RANGE * (float)channels);
        cost += GSF__DENSE_TINT * (tint < 1.0f ? tint : 1.0f);
    }
    return cost < 0.0f ? 0.0f : cost < GSF__DENSE_BAD ? cost : GSF__DENSE_BAD;
}

#define gsf__dense_add GSF__V(gsf__dense_add)
#define gsf__dense_match GSF__V(gsf__dense_match)
#define gsf__dense_part GSF__V(gsf__dense_part)

#define GSF__KERNELS "gsfixer_splat.h"
#define GSF__KERNELS_STEREO
#define GSF__KERNELS_SIMD128
#include "gsfixer.h"
#undef GSF__KERNELS_STEREO

#endif // GSF__ISA
#ifdef GSF__KERNELS_STEREO

// Partial sum i of the sums k, k + 1, ... k + GSF__LANES - 1, which have been transposed.
GSF__V_INLINE gsf__vf gsf__dense_part(gsf__vf sums[8 / GSF__LANES][GSF__DENSE_SUMS], int k, int i) {
    return sums[i / GSF__LANES][k + i % GSF__LANES];
}

// Adds samples of one channel, read at the texels `at` with the fractions fu and fv, to the sums.
GSF__V_INLINE void gsf__dense_add(const gsf__dense_patch* patch, int i, int channel, const uint32_t* texels, gsf__vi at,
                                  gsf__vf fu, gsf__vf fv, gsf__vf weight, gsf__vf* sum) {
    const gsf__vi texel = gsf__vi_gather(texels, at);
    const gsf__vf a = gsf__vi_floats(gsf__vi_byte(texel, 0)), b = gsf__vi_floats(gsf__vi_byte(texel, 1));
    const gsf__vf c = gsf__vi_floats(gsf__vi_byte(texel, 2)), d = gsf__vi_floats(gsf__vi_byte(texel, 3));
    const gsf__vf top = a + fu * (b - a), bottom = c + fu * (d - c);
    const gsf__vf s = top + fv * (bottom - top) - gsf__v_set(patch->center[channel]);
    const gsf__vf r = gsf__v_load(patch->value[channel] + i), wr = weight * r, ws = weight * s;
    sum[GSF__DENSE_RR] += wr * r;
    sum[GSF__DENSE_SS] += ws * s;
    sum[GSF__DENSE_RS] += wr * s;
    sum[GSF__DENSE_R + 2 * channel] += wr;
    sum[GSF__DENSE_S + 2 * channel] += ws;
}

// One pixel of the window per lane. Eight partial sums for any number of lanes, and no fused multiply-add, so that all
// instruction sets give the same bits.
GSF__V_INLINE float gsf__dense_match(const gsf__dense_window* window, const gsf__dense_patch* patch,
                                     const gsf__dense_warp* warp, int channels) {
    const float *base = warp->middle, *along_x = warp->along_x, *along_y = warp->along_y;
    const gsf__vf zero = gsf__v_set(0.0f), one = gsf__v_set(1.0f);
    const gsf__vf u_max = gsf__v_set((float)(warp->width - 1)), v_max = gsf__v_set((float)(warp->height - 1));
    const int used = channels > 1 ? GSF__DENSE_SUMS : 8; // of the sums
    gsf__vf sums[8 / GSF__LANES][GSF__DENSE_SUMS]; // indexed by constants with AVX2, so that they stay in registers
    for (int part = 0; part < 8 / GSF__LANES; part++) {
        gsf__vf* sum = sums[part];
        sum[0] = sum[1] = sum[2] = sum[3] = sum[4] = sum[5] = sum[6] = sum[7] = zero;
        if (channels == 1) continue;
        sum[8] = sum[9] = sum[10] = sum[11] = sum[12] = sum[13] = sum[14] = sum[15] = zero;
    }
    for (int i = 0; i < window->count; i += GSF__LANES) {
        const gsf__vf dx = gsf__v_load(window->dx + i), dy = gsf__v_load(window->dy + i);
        const gsf__vf X = gsf__v_set(base[0]) + dx * gsf__v_set(along_x[0]) + dy * gsf__v_set(along_y[0]);
        const gsf__vf Y = gsf__v_set(base[1]) + dx * gsf__v_set(along_x[1]) + dy * gsf__v_set(along_y[1]);
        const gsf__vf Z = gsf__v_set(base[2]) + dx * gsf__v_set(along_x[2]) + dy * gsf__v_set(along_y[2]);
        const gsf__vf inv = one / Z;
        gsf__vf u = X * inv, v = Y * inv;
        const gsf__vm inside = gsf__vm_and(gsf__v_gt(Z, zero),
            gsf__vm_and(gsf__vm_and(gsf__v_ge(u, zero), gsf__v_le(u, u_max)),
                        gsf__vm_and(gsf__v_ge(v, zero), gsf__v_le(v, v_max))));
        u = gsf__v_keep(inside, u); // samples outside read the first texel with weight 0
        v = gsf__v_keep(inside, v);
        const gsf__vi iu = gsf__v_truncate(u), iv = gsf__v_truncate(v);
        const gsf__vf fu = u - gsf__vi_floats(iu), fv = v - gsf__vi_floats(iv);
        const gsf__vi at = gsf__vi_add(gsf__vi_mul(iv, gsf__vi_set(warp->width)), iu);
        const gsf__vf weight = gsf__v_keep(inside, gsf__v_load(patch->weight + i));
        gsf__vf* sum = sums[i / GSF__LANES % (8 / GSF__LANES)];
        sum[GSF__DENSE_W] += weight;
        gsf__dense_add(patch, i, 0, warp->texels, at, fu, fv, weight, sum);
        if (channels == 1) continue;
        gsf__dense_add(patch, i, 1, warp->texels + warp->stride, at, fu, fv, weight, sum);
        gsf__dense_add(patch, i, 2, warp->texels + 2 * warp->stride, at, fu, fv, weight, sum);
    }
    float totals[GSF__DENSE_SUMS];
    for (int k = 0; k < used; k += GSF__LANES) {
        for (int part = 0; part < 8 / GSF__LANES; part++) gsf__v_transpose(sums[part] + k); // now a sum per lane
        gsf__v_store(totals + k, ((gsf__dense_part(sums, k, 0) + gsf__dense_part(sums, k, 1)) +
                                  (gsf__dense_part(sums, k, 2) + gsf__dense_part(sums, k, 3))) +
                                 ((gsf__dense_part(sums, k, 4) + gsf__dense_part(sums, k, 5)) +
                                  (gsf__dense_part(sums, k, 6) + gsf__dense_part(sums, k, 7))));
    }
    return gsf__dense_correlate(patch, totals, channels);
}

GSF__V_KERNEL float GSF__V(gsf__dense_cost_grey)(const gsf__dense_window* window, const gsf__dense_patch* patch,
                                                 const gsf__dense_warp* warp) {
    return gsf__dense_match(window, patch, warp, 1);
}

GSF__V_KERNEL float GSF__V(gsf__dense_cost_color)(const gsf__dense_window* window, const gsf__dense_patch* patch,
                                                  const gsf__dense_warp* warp) {
    return gsf__dense_match(window, patch, warp, 3);
}

#endif // GSF__KERNELS_STEREO
#ifndef GSF__ISA

static void gsf__dense_make_window(const gsf_dense_desc* d, gsf__dense_window* window) {
    memset(window, 0, sizeof *window);
    const int reach = d->radius / d->stride * d->stride;
    for (int dy = -reach; dy <= reach; dy += d->stride)
        for (int dx = -reach; dx <= reach; dx += d->stride) {
            window->dx[window->count] = (float)dx;
            window->dy[window->count] = (float)dy;
            window->spatial[window->count++] =
                (float)gsf__exp_f64(-(double)(dx * dx + dy * dy) / (2.0 * (double)d->radius * (double)d->radius));
        }
    window->count = (window->count + 7) / 8 * 8;
    for (int i = 0; i < 256; i++) window->tonal[i] = (float)gsf__exp_f64(-(double)i / (double)d->color_sigma);
}

// Returns 0 if the window has too little texture to match.
static int gsf__dense_make_patch(const gsf__dense_job* job, const gsf__dense_view* view, int x, int y,
                                 gsf__dense_patch* patch) {
    const gsf__dense_window* window = &job->window;
    const uint32_t* texels = job->texels + view->first;
    const int center = (int)(texels[y * view->width + x] & 255u);
    float sum = 0.0f, first = 0.0f, second = 0.0f;
    for (int i = 0; i < window->count; i++) {
        const int px = x + (int)window->dx[i], py = y + (int)window->dy[i];
        float weight = 0.0f, value = 0.0f;
        if (window->spatial[i] > 0.0f && px >= 0 && px < view->width && py >= 0 && py < view->height) {
            const int difference = (int)(texels[py * view->width + px] & 255u) - center;
            weight = window->spatial[i] * window->tonal[difference < 0 ? -difference : difference];
            value = (float)difference;
        }
        patch->weight[i] = weight;
        patch->value[0][i] = value;
        sum += weight;
        first += weight * value;
        second += weight * value * value;
    }
    patch->center[0] = (float)center;
    patch->weight_sum = sum;
    for (int c = 0; c < 3 && job->channels == 3; c++) {
        const uint32_t* channel = texels + (size_t)(c + 1) * job->pixel_count;
        const int middle = (int)(channel[y * view->width + x] & 255u);
        patch->center[c] = (float)middle;
        for (int i = 0; i < window->count; i++) {
            const int at = (y + (int)window->dy[i]) * view->width + x + (int)window->dx[i];
            patch->value[c][i] = patch->weight[i] > 0.0f ? (float)((int)(channel[at] & 255u) - middle) : 0.0f;
        }
    }
    return second * sum - first * first > GSF__DENSE_MIN_VARIANCE * sum * sum;
}

// ---- planes

// Whether the plane lies within the depth range and is not seen edge-on.
static int gsf__dense_plane_valid(const gsf__dense_view* view, int x, int y, const gsf__dense_plane* plane) {
    if (!(plane->w >= view->w_min && plane->w <= view->w_max)) return 0;
    const float ex = view->cx - (float)x, ey = view->cy - (float)y; // normal: (fx gx, fy gy, 1/z at cx, cy)
    const float nx = view->fx * plane->gx, ny = view->fy * plane->gy, nz = plane->w + plane->gx * ex + plane->gy * ey;
    const float rx = ex / view->fx, ry = ey / view->fy;
    const float squares = (nx * nx + ny * ny + nz * nz) * (rx * rx + ry * ry + 1.0f);
    return plane->w * plane->w >= GSF__DENSE_MIN_COS * GSF__DENSE_MIN_COS * squares;
}

// Unit normal in camera coordinates, pointing away from the camera.
static void gsf__dense_normal(const gsf__dense_view* view, int x, int y, const gsf__dense_plane* plane, float n[3]) {
    n[0] = view->fx * plane->gx;
    n[1] = view->fy * plane->gy;
    n[2] = plane->w + plane->gx * (view->cx - (float)x) + plane->gy * (view->cy - (float)y);
    const float inv = 1.0f / sqrtf(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    for (int k = 0; k < 3; k++) n[k] *= inv;
}

// Makes the plane with inverse depth w at the pixel and normal n (of any length). Returns 0 if it is not valid.
static int gsf__dense_plane_of(const gsf__dense_view* view, int x, int y, float w, const float n[3],
                               gsf__dense_plane* plane) {
    const float rx = ((float)x - view->cx) / view->fx, ry = ((float)y - view->cy) / view->fy;
    const float facing = n[0] * rx + n[1] * ry + n[2];
    if (!(facing > 1e-6f)) return 0;
    plane->w = w;
    plane->gx = n[0] / (view->fx * facing) * w;
    plane->gy = n[1] / (view->fy * facing) * w;
    plane->cost = GSF__DENSE_BAD;
    return gsf__dense_plane_valid(view, x, y, plane);
}

// Four uniform random numbers in (-1,1).
static void gsf__dense_random(uint64_t seed, uint64_t stream, uint64_t index, float out[4]) {
    const uint64_t bits = gsf_draw_bits(seed, stream, index);
    for (int k = 0; k < 4; k++) out[k] = ((float)(bits >> (16 * k) & 65535u) - 32767.5f) * (1.0f / 32768.0f);
}

static uint64_t gsf__dense_stream(const gsf__dense_job* job, const gsf__dense_view* view) {
    return (uint64_t)view->index << 32 | (uint64_t)(uint32_t)job->level << 16 | (uint64_t)(uint32_t)(job->iteration + 1);
}

// ---- one pixel

typedef struct gsf__dense_pixel {
    const gsf__dense_job* job;
    const gsf__dense_view* view;
    int x, y;
    gsf__dense_patch patch;
    float base[GSF__DENSE_SOURCES][3];  // M (x,y,1)
    float weights[GSF__DENSE_SOURCES];  // of the sources; they sum to 1
    float motion;                       // largest image motion in a source view, pixels per unit of inverse depth
} gsf__dense_pixel;

// Returns 0 if the pixel has too little texture to match.
static int gsf__dense_begin(gsf__dense_pixel* p, const gsf__dense_job* job, const gsf__dense_view* view, int x, int y) {
    p->job = job;
    p->view = view;
    p->x = x;
    p->y = y;
    for (int s = 0; s < view->source_count; s++) {
        const float* m = view->sources[s].m;
        for (int k = 0; k < 3; k++) p->base[s][k] = m[3 * k] * (float)x + m[3 * k + 1] * (float)y + m[3 * k + 2];
    }
    return gsf__dense_make_patch(job, view, x, y, &p->patch);
}

static float gsf__dense_cost(const gsf__dense_pixel* p, int s, const gsf__dense_plane* plane) {
    const gsf__dense_source* source = &p->view->sources[s];
    const gsf__dense_view* other = &p->job->views[source->view];
    gsf__dense_warp warp;
    for (int k = 0; k < 3; k++) {
        warp.middle[k] = p->base[s][k] + source->t[k] * plane->w;
        warp.along_x[k] = source->m[3 * k] + source->t[k] * plane->gx;
        warp.along_y[k] = source->m[3 * k + 1] + source->t[k] * plane->gy;
    }
    warp.texels = p->job->texels + other->first + (p->job->channels == 3 ? p->job->pixel_count : 0);
    warp.stride = p->job->pixel_count;
    warp.width = other->width;
    warp.height = other->height;
    if (!(warp.middle[2] > 0.0f)) return GSF__DENSE_BAD;
    const float u = warp.middle[0], v = warp.middle[1], z = warp.middle[2];
    const float right = ((float)other->width - 0.5f) * z, bottom = ((float)other->height - 0.5f) * z;
    if (!(u >= -0.5f * z && u <= right && v >= -0.5f * z && v <= bottom)) return GSF__DENSE_BAD;
    return p->job->cost_fns[p->job->channels == 3](&p->job->window, &p->patch, &warp);
}

// Forward-backward reprojection error, at most 3 pixels: the pixel is mapped to source s by `plane` and back by the
// plane found there.
static float gsf__dense_detour(const gsf__dense_pixel* p, int s, const gsf__dense_plane* plane) {
    const gsf__dense_source* source = &p->view->sources[s];
    const gsf__dense_view* other = &p->job->views[source->view];
    const float X = p->base[s][0] + source->t[0] * plane->w, Y = p->base[s][1] + source->t[1] * plane->w;
    const float Z = p->base[s][2] + source->t[2] * plane->w;
    if (!(Z > 0.0f)) return 3.0f;
    const float u = X / Z, v = Y / Z;
    if (!(u > -0.5f && u < (float)other->width - 0.5f && v > -0.5f && v < (float)other->height - 0.5f)) return 3.0f;
    const int iu = (int)(u + 0.5f), iv = (int)(v + 0.5f);
    const gsf__dense_plane* there = p->job->others + other->first + (size_t)iv * (size_t)other->width + (size_t)iu;
    if (!(there->cost < 1.0f)) return 3.0f;
    const float w = there->w + there->gx * (u - (float)iu) + there->gy * (v - (float)iv);
    const float *m = source->back_m, *t = source->back_t;
    const float bz = m[6] * u + m[7] * v + m[8] + t[2] * w;
    if (!(bz > 0.0f)) return 3.0f;
    const float dx = (m[0] * u + m[1] * v + m[2] + t[0] * w) / bz - (float)p->x;
    const float dy = (m[3] * u + m[4] * v + m[5] + t[1] * w) / bz - (float)p->y;
    const float squared = dx * dx + dy * dy;
    return squared < 9.0f ? sqrtf(squared) : 3.0f;
}

// Weights the sources by how well the best three of the candidate planes match in each. No candidate matches in a view
// where the pixel is occluded.
static void gsf__dense_weigh(gsf__dense_pixel* p, float costs[][GSF__DENSE_SOURCES], int count) {
    float sum = 0.0f, best = 0.0f;
    for (int s = 0; s < p->view->source_count; s++) {
        float top[3] = {0.0f, 0.0f, 0.0f};
        for (int i = 0; i < count; i++) {
            float c = costs[i][s] * (1.0f / 0.3f);
            c *= c;
            float good = 1.0f / (1.0f + c * c);
            for (int k = 0; k < 3; k++)
                if (good > top[k]) {
                    const float swap = top[k];
                    top[k] = good;
                    good = swap;
                }
        }
        p->weights[s] = count >= 3 ? top[0] + top[1] + top[2] : top[0];
        if (p->weights[s] > best) best = p->weights[s];
    }
    for (int s = 0; s < p->view->source_count; s++) {
        if (p->weights[s] < 0.1f * best) p->weights[s] = 0.0f;
        sum += p->weights[s];
    }
    for (int s = 0; s < p->view->source_count; s++) p->weights[s] /= sum;
}

static float gsf__dense_mean(const gsf__dense_pixel* p, const float* costs) {
    float sum = 0.0f;
    for (int s = 0; s < p->view->source_count; s++) sum += p->weights[s] * costs[s];
    return sum;
}

// Weighted cost of a plane including the geometric term. costs: matching cost per source, without that term. Stops
// early once the sum reaches `limit`.
static float gsf__dense_judge(const gsf__dense_pixel* p, const gsf__dense_plane* plane, float limit, float* costs) {
    float sum = 0.0f;
    for (int s = 0; s < p->view->source_count; s++) {
        if (p->weights[s] == 0.0f) continue;
        costs[s] = gsf__dense_cost(p, s, plane);
        sum += p->weights[s] * costs[s];
        if (p->job->others) sum += p->weights[s] * 0.1f * gsf__dense_detour(p, s, plane);
        if (sum >= limit) break;
    }
    return sum;
}

static void gsf__dense_measure_motion(gsf__dense_pixel* p, float w) {
    float best = 0.0f;
    for (int s = 0; s < p->view->source_count; s++) {
        const float* t = p->view->sources[s].t;
        const float z = p->base[s][2] + t[2] * w;
        if (!(z > 0.0f)) continue;
        const float u = (p->base[s][0] + t[0] * w) / z, v = (p->base[s][1] + t[1] * w) / z;
        const float du = (t[0] - u * t[2]) / z, dv = (t[1] - v * t[2]) / z;
        const float squared = du * du + dv * dv;
        if (squared > best) best = squared;
    }
    p->motion = sqrtf(best);
}

// Candidate planes for the pixel: the cheapest one of each of eight regions (Xu and Tao 2019), which are four V-shaped
// ones close to the pixel and four straight ones that reach 23 pixels. All their pixels are of the other colour.
static int gsf__dense_gather(const gsf__dense_pixel* p, gsf__dense_plane* planes) {
    static const int8_t near_offsets[11][2] = {{0, 1}, {-1, 2}, {1, 2}, {-2, 3}, {2, 3}, {-3, 4}, {3, 4}}; // 7 of 11
    const gsf__dense_view* view = p->view;
    const gsf__dense_plane* all = p->job->planes + view->first;
    int count = 0;
    const int regions = p->job->roam ? 8 : 4; // the coarsest level has propagated over long distances
    for (int region = 0; region < regions; region++) {
        const int side = region & 3; // down, up, right, left
        const int steps = region < 4 ? 7 : 11;
        const gsf__dense_plane* best = NULL;
        int best_dx = 0, best_dy = 0;
        for (int i = 0; i < steps; i++) {
            const int across = region < 4 ? near_offsets[i][0] : 0;
            const int along = region < 4 ? near_offsets[i][1] : 2 * i + 3;
            const int dx = side < 2 ? across : side == 2 ? along : -along;
            const int dy = side >= 2 ? across : side == 0 ? along : -along;
            const int x = p->x + dx, y = p->y + dy;
            if (x < 0 || x >= view->width || y < 0 || y >= view->height) continue;
            const gsf__dense_plane* plane = all + (size_t)y * (size_t)view->width + (size_t)x;
            if (best ? plane->cost < best->cost : plane->cost < GSF__DENSE_BAD) {
                best = plane;
                best_dx = dx;
                best_dy = dy;
            }
        }
        if (!best) continue;
        gsf__dense_plane* out = planes + count;
        *out = *best;
        out->w = best->w - best->gx * (float)best_dx - best->gy * (float)best_dy;
        count += gsf__dense_plane_valid(view, p->x, p->y, out);
    }
    return count;
}

// Whether two planes map the whole window to within a few hundredths of a pixel of each other in every source view.
static int gsf__dense_same(const gsf__dense_pixel* p, const gsf__dense_plane* a, const gsf__dense_plane* b) {
    const float limit = 0.03f, reach = (float)p->job->desc.radius;
    const float dw = a->w - b->w, dx = a->gx - b->gx, dy = a->gy - b->gy;
    return ((dw < 0.0f ? -dw : dw) + reach * (dx < 0.0f ? -dx : dx) + reach * (dy < 0.0f ? -dy : dy)) * p->motion < limit;
}

// Tries random perturbations of the best plane, and at the coarsest level also random depths and normals.
static void gsf__dense_refine(const gsf__dense_pixel* p, gsf__dense_plane* best, float* best_costs, float* best_sum) {
    const gsf__dense_job* job = p->job;
    const gsf__dense_view* view = p->view;
    const uint64_t stream = gsf__dense_stream(job, view);
    const uint64_t index = (uint64_t)p->y * (uint64_t)view->width + (uint64_t)p->x;
    const float step_w = job->step_pixels / (p->motion > 1e-20f ? p->motion : 1e-20f);
    const int tries = job->roam ? 6 : 3;
    for (int k = 0; k < tries; k++) {
        float r[4], n[3], costs[GSF__DENSE_SOURCES];
        gsf__dense_random(job->desc.seed, stream, 8 * index + (uint64_t)k, r);
        gsf__dense_plane plane = *best;
        float w = best->w;
        if (k == 0 || k == 2) w += step_w * r[3];
        if (k == 3 || k == 4) w = view->w_min + (view->w_max - view->w_min) * 0.5f * (r[3] + 1.0f);
        if (k == 4 || k == 5) {
            n[0] = 1.5f * r[0] + ((float)p->x - view->cx) / view->fx;
            n[1] = 1.5f * r[1] + ((float)p->y - view->cy) / view->fy;
            n[2] = 1.0f;
        } else {
            gsf__dense_normal(view, p->x, p->y, best, n);
            if (k == 1 || k == 2)
                for (int a = 0; a < 3; a++) n[a] += job->step_normal * r[a];
        }
        if (!gsf__dense_plane_of(view, p->x, p->y, w, n, &plane)) continue;
        const float sum = gsf__dense_judge(p, &plane, *best_sum, costs);
        if (!(sum < *best_sum)) continue;
        *best = plane;
        *best_sum = sum;
        for (int s = 0; s < view->source_count; s++)
            if (p->weights[s] > 0.0f) best_costs[s] = costs[s];
    }
    for (int s = 0; s < view->source_count; s++) // gsf__dense_judge skips these
        if (p->weights[s] == 0.0f) best_costs[s] = gsf__dense_cost(p, s, best);
}

static void gsf__dense_visit(const gsf__dense_job* job, const gsf__dense_view* view, int x, int y) {
    if (((x + y) & 1) != job->color) return;
    const size_t at = view->first + (size_t)y * (size_t)view->width + (size_t)x;
    gsf__dense_pixel p;
    if (!gsf__dense_begin(&p, job, view, x, y)) return;
    gsf__dense_plane planes[GSF__DENSE_PLANES];
    float costs[GSF__DENSE_PLANES][GSF__DENSE_SOURCES], sums[GSF__DENSE_PLANES];
    float* own = job->source_costs + GSF__DENSE_SOURCES * at;
    planes[0] = job->planes[at];
    gsf__dense_measure_motion(&p, planes[0].w);
    memcpy(costs[0], own, sizeof costs[0]);
    const int count = 1 + gsf__dense_gather(&p, planes + 1);
    for (int i = 1; i < count; i++) {
        int twin = -1;
        for (int k = 0; k < i && twin < 0; k++)
            if (gsf__dense_same(&p, planes + i, planes + k)) twin = k;
        for (int s = 0; s < view->source_count; s++)
            costs[i][s] = twin >= 0 ? costs[twin][s] : gsf__dense_cost(&p, s, planes + i);
    }
    gsf__dense_weigh(&p, costs, count);
    int best = 0;
    for (int i = 0; i < count; i++) {
        sums[i] = gsf__dense_mean(&p, costs[i]);
        if (job->others)
            for (int s = 0; s < view->source_count; s++)
                if (p.weights[s] > 0.0f) sums[i] += p.weights[s] * 0.1f * gsf__dense_detour(&p, s, planes + i);
        if (sums[i] < sums[best]) best = i;
    }
    gsf__dense_refine(&p, planes + best, costs[best], sums + best);
    planes[best].cost = gsf__dense_mean(&p, costs[best]);
    job->planes[at] = planes[best];
    memcpy(own, costs[best], sizeof costs[0]);
}

// Initial planes: upsampled from the coarser level, or random ones, most of them near the depth of the sparse points.
static void gsf__dense_start(const gsf__dense_job* job, const gsf__dense_view* view, int x, int y) {
    const uint64_t stream = gsf__dense_stream(job, view);
    const size_t pixel = (size_t)y * (size_t)view->width + (size_t)x, at = view->first + pixel;
    gsf__dense_plane plane;
    float* costs = job->source_costs + GSF__DENSE_SOURCES * at;
    gsf__dense_pixel p;
    int valid = 0;
    if (job->coarse_planes) {
        const gsf__dense_view* coarse = job->coarse_views + (view - job->views);
        const float sx = (float)coarse->width / (float)view->width;
        const float sy = (float)coarse->height / (float)view->height;
        const float u = ((float)x + 0.5f) * sx - 0.5f, v = ((float)y + 0.5f) * sy - 0.5f;
        const int iu = (int)(u + 0.5f), iv = (int)(v + 0.5f);
        plane = job->coarse_planes[coarse->first + (size_t)iv * (size_t)coarse->width + (size_t)iu];
        plane.w += plane.gx * (u - (float)iu) + plane.gy * (v - (float)iv);
        plane.gx *= sx;
        plane.gy *= sy;
        valid = gsf__dense_plane_valid(view, x, y, &plane);
    }
    for (uint64_t attempt = 0; !valid && attempt < 8; attempt++) {
        float r[4], n[3];
        gsf__dense_random(job->desc.seed, stream, 8 * (uint64_t)pixel + attempt, r);
        const float seed = job->seeds ? job->seeds[at] : 0.0f, spread = 0.5f * (view->w_max - view->w_min);
        float w = view->w_min + spread * (r[3] + 1.0f);
        if (seed > 0.0f && r[2] > -0.5f) w = seed * (1.0f + 0.05f * r[3]); // in three of four attempts
        n[0] = r[0] + ((float)x - view->cx) / view->fx;
        n[1] = r[1] + ((float)y - view->cy) / view->fy;
        n[2] = 1.0f;
        valid = gsf__dense_plane_of(view, x, y, w, n, &plane);
    }
    if (!valid) {
        plane.w = 0.5f * (view->w_min + view->w_max);
        plane.gx = plane.gy = 0.0f;
    }
    for (int s = 0; s < GSF__DENSE_SOURCES; s++) costs[s] = GSF__DENSE_BAD;
    plane.cost = GSF__DENSE_BAD;
    if (gsf__dense_begin(&p, job, view, x, y)) {
        for (int s = 0; s < view->source_count; s++) costs[s] = gsf__dense_cost(&p, s, &plane);
        gsf__dense_weigh(&p, (float(*)[GSF__DENSE_SOURCES])(void*)costs, 1);
        plane.cost = gsf__dense_mean(&p, costs);
    }
    job->planes[at] = plane;
}

// ---- which views to compare, and how

static int gsf__dense_tracked(const gsf_scene* scene, size_t point, uint32_t view) {
    for (size_t i = scene->track_begin[point]; i < scene->track_begin[point + 1]; i++)
        if (scene->track_views[i] == view) return 1;
    return 0;
}

static int gsf__dense_in_view(const gsf_camera* camera, const double point[3], double* u, double* v, double* depth) {
    return gsf_project_point(camera, point, u, v, depth) && *u >= 0.0 && *u < camera->width && *v >= 0.0 &&
           *v < camera->height;
}

static int gsf__dense_usable(const gsf__dense_job* job, size_t i) {
    return gsf__point_counts(job->scene->points, job->keep, i);
}

// Depth range of a view: from 0.7 times the 2nd to 1.4 times the 98th percentile of the depths of its sparse points.
// With fewer than 20 of them, from 1/3 to 60 times the median baseline, beyond which parallax is too small. The
// caller's limits override both.
static void gsf__dense_range(gsf__dense_job* job, gsf__dense_view* view, double* depths, double* low, double* high) {
    const gsf_scene* scene = job->scene;
    size_t n = 0;
    double u, v, z;
    for (size_t i = 0; i < scene->point_count; i++)
        if (gsf__dense_usable(job, i) && gsf__dense_in_view(&view->camera, scene->points + 3 * i, &u, &v, &z))
            depths[n++] = z;
    if (n >= 20) {
        qsort(depths, n, sizeof *depths, gsf__compare_doubles);
        *low = 0.7 * depths[n / 50];
        *high = 1.4 * depths[n - 1 - n / 50];
    } else {
        double center[3], other[3];
        gsf_get_camera_center(&view->camera, center);
        n = 0;
        for (size_t i = 0; i < job->view_count; i++) {
            gsf_get_camera_center(&job->views[i].camera, other);
            const double dx = other[0] - center[0], dy = other[1] - center[1], dz = other[2] - center[2];
            if (&job->views[i] != view) depths[n++] = sqrt(dx * dx + dy * dy + dz * dz);
        }
        qsort(depths, n, sizeof *depths, gsf__compare_doubles);
        *low = depths[n / 2] / 3.0;
        *high = depths[n / 2] * 60.0;
    }
    if (job->desc.depth_min > 0.0) *low = job->desc.depth_min;
    if (job->desc.depth_max > 0.0) *high = job->desc.depth_max;
    if (!(*low > 0.0 && *high > *low && isfinite(*high)))
        *low = *high = 0.0; // all cameras at one position, or the caller's limits leave no range
    view->w_min = *high > 0.0 ? (float)(1.0 / *high) : 0.0f;
    view->w_max = *low > 0.0 ? (float)(1.0 / *low) : 0.0f;
}

// Cosine of the angle at `point` between the directions to two camera centres.
static double gsf__ray_cosine(const double point[3], const double a[3], const double b[3]) {
    double along = 0.0, n0 = 0.0, n1 = 0.0;
    for (int c = 0; c < 3; c++) {
        const double p = point[c] - a[c], q = point[c] - b[c];
        along += p * q;
        n0 += p * p;
        n1 += q * q;
    }
    return along / sqrt(n0 * n1 + 1e-300);
}

// How strongly a point speaks for matching two views: 0 if its viewing rays differ by less than min_angle, highest
// around ten degrees, lower for wider angles and for different image scales.
static double gsf__dense_vote(const gsf__dense_job* job, const gsf_camera* a, const gsf_camera* b, const double point[3],
                              double depth_a, double depth_b) {
    double ca[3], cb[3];
    gsf_get_camera_center(a, ca);
    gsf_get_camera_center(b, cb);
    const double c = gsf__ray_cosine(point, ca, cb);
    const double degrees = gsf__acos_f64(c < -1.0 ? -1.0 : c > 1.0 ? 1.0 : c) * 57.29577951308232;
    if (!(degrees >= (double)job->desc.min_angle)) return 0.0;
    const double off = (degrees - 10.0) / (degrees < 10.0 ? 4.0 : 20.0), scale = a->fx / depth_a / (b->fx / depth_b);
    return (scale < 1.0 ? scale : 1.0 / scale) / (1.0 + off * off);
}

// Chooses view->sources (sets only their `view`): the views with the highest scores over the sparse points visible in
// both, where points not tracked in both count a fifth. With fewer than 20 points, a grid through the view's depth
// range is scored as well.
static void gsf__dense_choose_sources(gsf__dense_job* job, size_t r, double low, double high, double* scores) {
    const gsf_scene* scene = job->scene;
    gsf__dense_view* view = job->views + r;
    double c2w[16], u, v, z, z2;
    size_t votes = 0;
    for (size_t s = 0; s < job->view_count; s++) scores[s] = 0.0;
    for (size_t i = 0; i < scene->point_count; i++) {
        const double* point = scene->points + 3 * i;
        if (!gsf__dense_usable(job, i) || !gsf__dense_in_view(&view->camera, point, &u, &v, &z)) continue;
        const int here = gsf__dense_tracked(scene, i, view->index);
        votes++;
        for (size_t s = 0; s < job->view_count; s++) {
            const gsf_camera* camera = &job->views[s].camera;
            if (s == r || !gsf__dense_in_view(camera, point, &u, &v, &z2)) continue;
            const int both = here && gsf__dense_tracked(scene, i, job->views[s].index);
            scores[s] += (both ? 1.0 : 0.2) * gsf__dense_vote(job, &view->camera, camera, point, z, z2);
        }
    }
    gsf_get_camera_c2w(&view->camera, c2w);
    for (int i = 0; i < 6 * 6 * 6 && votes < 20 && low > 0.0; i++) {
        z = 1.0 / (1.0 / high + (1.0 / low - 1.0 / high) * (i / 36 + 0.5) / 6.0);
        const double x = ((i % 6 + 0.5) / 6.0 * view->camera.width - view->camera.cx) / view->camera.fx * z;
        const double y = ((i / 6 % 6 + 0.5) / 6.0 * view->camera.height - view->camera.cy) / view->camera.fy * z;
        double point[3];
        for (int k = 0; k < 3; k++) point[k] = c2w[k] * x + c2w[4 + k] * y + c2w[8 + k] * z + c2w[12 + k];
        for (size_t s = 0; s < job->view_count; s++)
            if (s != r && gsf__dense_in_view(&job->views[s].camera, point, &u, &v, &z2))
                scores[s] += gsf__dense_vote(job, &view->camera, &job->views[s].camera, point, z, z2);
    }
    view->source_count = 0;
    while (low > 0.0 && view->source_count < job->desc.sources) {
        size_t best = r;
        for (size_t s = 0; s < job->view_count; s++)
            if (s != r && scores[s] > 0.0 && (best == r || scores[s] > scores[best])) best = s;
        if (best == r) break;
        view->sources[view->source_count++].view = (int32_t)best;
        scores[best] = 0.0;
    }
}

// m, t and rotation of gsf__dense_source, from camera `from` to camera `to`. rotation may be NULL.
static void gsf__dense_relate(const gsf_camera* from, const gsf_camera* to, float m[9], float t[3], float rotation[9]) {
    double c2w[16], rel[16];
    gsf_get_camera_c2w(from, c2w);
    gsf__mat4_mul(to->w2c, c2w, rel);
    const double fx = from->fx, fy = from->fy, cx = from->cx - 0.5, cy = from->cy - 0.5;
    double rk[3][3]; // R K^-1
    for (int i = 0; i < 3; i++) {
        const double a = rel[i], b = rel[4 + i], c = rel[8 + i];
        rk[i][0] = a / fx;
        rk[i][1] = b / fy;
        rk[i][2] = c - a * cx / fx - b * cy / fy;
        if (rotation) {
            rotation[3 * i] = (float)a;
            rotation[3 * i + 1] = (float)b;
            rotation[3 * i + 2] = (float)c;
        }
    }
    for (int j = 0; j < 3; j++) {
        m[j] = (float)(to->fx * rk[0][j] + (to->cx - 0.5) * rk[2][j]);
        m[3 + j] = (float)(to->fy * rk[1][j] + (to->cy - 0.5) * rk[2][j]);
        m[6 + j] = (float)rk[2][j];
    }
    t[0] = (float)(to->fx * rel[12] + (to->cx - 0.5) * rel[14]);
    t[1] = (float)(to->fy * rel[13] + (to->cy - 0.5) * rel[14]);
    t[2] = (float)rel[14];
}

// ---- levels

static void gsf__dense_free_level(gsf__dense_job* job) {
    for (size_t i = 0; i < job->view_count; i++) {
        gsf_destroy_image(job->ctx, &job->views[i].color);
        gsf_destroy_image(job->ctx, &job->views[i].weight);
    }
    gsf_free(job->ctx, job->planes);
    gsf__arena_free(&job->level_arena);
    job->planes = job->others = NULL;
    job->seeds = NULL;
}

// Texels of one channel: 0 grey, 1 red, 2 green, 3 blue.
static void gsf__dense_texels(const gsf__dense_view* view, int channel, uint32_t* texels) {
    const uint8_t* rgb = (const uint8_t*)view->color.data;
    const int32_t width = view->width, height = view->height;
    for (size_t i = 0; i < (size_t)width * (size_t)height; i++)
        texels[i] = channel ? rgb[3 * i + (size_t)channel - 1]
                            : (77u * rgb[3 * i] + 150u * rgb[3 * i + 1] + 29u * rgb[3 * i + 2] + 128u) >> 8;
    for (int32_t y = 0; y < height; y++) // packing in place: low bytes keep each texel's own grey
        for (int32_t x = 0; x < width; x++) {
            const int32_t right = x + 1 < width, below = y + 1 < height ? width : 0;
            uint32_t* t = texels + (size_t)y * (size_t)width + (size_t)x;
            t[0] |= (t[right] & 255u) << 8 | (t[below] & 255u) << 16 | (t[below + right] & 255u) << 24;
        }
}

// Working size of a view at a level: at most max_size, halved per level.
static void gsf__dense_size(const gsf_camera* camera, int32_t max_size, int32_t level, int32_t* width, int32_t* height) {
    const int32_t longer = camera->width > camera->height ? camera->width : camera->height;
    const double scale = (longer > max_size ? (double)max_size / longer : 1.0) / (double)(1 << level);
    *width = (int32_t)(camera->width * scale + 0.5);
    *height = (int32_t)(camera->height * scale + 0.5);
    if (*width < 1) *width = 1;
    if (*height < 1) *height = 1;
}

static gsf_result gsf__dense_resize(gsf_context* ctx, const gsf__dense_view* view, gsf_image* image) {
    gsf_image sized;
    if (image->width == view->width && image->height == view->height) return GSF_OK;
    GSF__TRY(gsf_make_image(ctx, image->dtype, view->width, view->height, image->channels, &sized));
    const gsf_result result = gsf_resize_image(ctx, image, GSF_RESIZE_PIL_BILINEAR, &sized);
    gsf_destroy_image(ctx, image);
    *image = sized;
    return result;
}

// Loads view->color and view->weight at the working size. Colours are resized premultiplied by their weight.
static gsf_result gsf__dense_load_color(gsf__dense_job* job, gsf__dense_view* view) {
    gsf_context* ctx = job->ctx;
    const gsf_scene_view* from = &job->scene->views[view->index];
    const int weighted = from->weight.data != NULL;
    gsf_image weight, joint;
    memset(&weight, 0, sizeof weight);
    memset(&joint, 0, sizeof joint);
    GSF__TRY(gsf_make_image(ctx, GSF_U8, from->image.width, from->image.height, 3, &view->color));
    GSF__TRY(gsf_convert_image(ctx, &from->image, &view->color));
    if (!weighted) return gsf__dense_resize(ctx, view, &view->color);
    gsf_result result = gsf_make_image(ctx, GSF_U8, from->weight.width, from->weight.height, 1, &weight);
    if (result == GSF_OK) result = gsf_convert_image(ctx, &from->weight, &weight);
    if (result == GSF_OK) result = gsf__join_weight(ctx, &view->color, &weight, &joint);
    if (result == GSF_OK) result = gsf__dense_resize(ctx, view, &joint);
    if (result == GSF_OK) result = gsf__joint_bytes(ctx, &joint);
    gsf_destroy_image(ctx, &view->color);
    if (result == GSF_OK) result = gsf__part_weight(ctx, &joint, &view->color, &view->weight);
    gsf_destroy_image(ctx, &joint);
    gsf_destroy_image(ctx, &weight);
    return result;
}

// Gives every pixel the inverse depth of the nearest projected sparse point: a two-pass city-block distance transform.
static void gsf__dense_spread_seeds(gsf__dense_job* job, gsf__dense_view* view, int32_t* distance) {
    const gsf_scene* scene = job->scene;
    const int32_t width = view->width, height = view->height, none = 1 << 28;
    float* seeds = job->seeds + view->first;
    for (int32_t i = 0; i < width * height; i++) distance[i] = none;
    for (size_t i = 0; i < scene->point_count; i++) {
        double u, v, z;
        if (!gsf__dense_usable(job, i) || !gsf__dense_in_view(&view->camera, scene->points + 3 * i, &u, &v, &z)) continue;
        const int32_t at = (int32_t)v * width + (int32_t)u;
        const float w = (float)(1.0 / z);
        if (distance[at] && w >= view->w_min && w <= view->w_max) {
            distance[at] = 0;
            seeds[at] = w;
        } else if (!distance[at] && w > seeds[at] && w <= view->w_max) {
            seeds[at] = w; // the nearer point occludes the other
        }
    }
    for (int pass = 0; pass < 2; pass++)
        for (int32_t k = 0; k < width * height; k++) {
            const int32_t i = pass ? width * height - 1 - k : k, x = i % width, y = i / width;
            const int32_t beside = pass ? (x + 1 < width ? i + 1 : i) : (x ? i - 1 : i);
            const int32_t along = pass ? (y + 1 < height ? i + width : i) : (y ? i - width : i);
            const int32_t from = distance[beside] < distance[along] ? beside : along;
            if (distance[from] + 1 < distance[i]) {
                distance[i] = distance[from] + 1;
                seeds[i] = seeds[from];
            }
        }
}

// Sets up the views and arrays of a level. The caller has already taken over or freed those of the coarser level.
static gsf_result gsf__dense_begin_level(gsf__dense_job* job, int32_t level, int with_seeds) {
    gsf_context* ctx = job->ctx;
    job->level = level;
    job->pixel_count = job->block_count = 0;
    int32_t most = 0;
    for (size_t i = 0; i < job->view_count; i++) {
        gsf__dense_view* view = job->views + i;
        const gsf_camera* camera = &job->scene->views[view->index].camera;
        gsf__dense_size(camera, job->desc.max_size, level, &view->width, &view->height);
        view->camera = gsf_resize_camera(camera, view->width, view->height);
        view->fx = (float)view->camera.fx;
        view->fy = (float)view->camera.fy;
        view->cx = (float)(view->camera.cx - 0.5);
        view->cy = (float)(view->camera.cy - 0.5);
        view->first = job->pixel_count;
        if (view->width * view->height > most) most = view->width * view->height;
        job->pixel_count += (size_t)view->width * (size_t)view->height;
        job->block_count += (size_t)((view->height + GSF__DENSE_ROWS - 1) / GSF__DENSE_ROWS);
        GSF__TRY(gsf__dense_load_color(job, view));
    }
    if (job->pixel_count >= UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "dense points: %zu pixels in all are too many", job->pixel_count);
    gsf__arena* arena = &job->level_arena;
    job->planes = (gsf__dense_plane*)gsf_alloc(ctx, job->pixel_count, sizeof(gsf__dense_plane));
    job->channels = level ? 3 : 1;
    const int planes = level ? 4 : 1; // grey weighs the window's samples, also where colours are matched
    job->texels = (uint32_t*)gsf__arena_alloc(arena, job->pixel_count, (size_t)planes * sizeof(uint32_t));
    job->source_costs = (float*)gsf__arena_alloc(arena, job->pixel_count, GSF__DENSE_SOURCES * sizeof(float));
    job->blocks = (gsf__dense_block*)gsf__arena_alloc(arena, job->block_count, sizeof(gsf__dense_block));
    if (with_seeds) job->seeds = (float*)gsf__arena_alloc_zeroed(arena, job->pixel_count, sizeof(float));
    if (!job->planes || arena->failed) return GSF_ERROR_OUT_OF_MEMORY;
    size_t block = 0;
    for (size_t i = 0; i < job->view_count; i++) {
        gsf__dense_view* view = job->views + i;
        for (int c = 0; c < planes; c++)
            gsf__dense_texels(view, c, job->texels + (size_t)c * job->pixel_count + view->first);
        for (int32_t row = 0; row < view->height; row += GSF__DENSE_ROWS, block++) {
            job->blocks[block].view = (uint32_t)i;
            job->blocks[block].row = row;
        }
        for (int32_t s = 0; s < view->source_count; s++) {
            gsf__dense_source* source = view->sources + s;
            const gsf_camera* other = &job->scene->views[job->views[source->view].index].camera;
            int32_t width, height;
            gsf__dense_size(other, job->desc.max_size, level, &width, &height);
            const gsf_camera to = gsf_resize_camera(other, width, height);
            gsf__dense_relate(&view->camera, &to, source->m, source->t, source->rotation);
            gsf__dense_relate(&to, &view->camera, source->back_m, source->back_t, NULL);
        }
    }
    if (!with_seeds) return GSF_OK;
    int32_t* distance = (int32_t*)gsf_alloc(ctx, (size_t)most, sizeof(int32_t));
    if (!distance) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < job->view_count; i++) gsf__dense_spread_seeds(job, job->views + i, distance);
    gsf_free(ctx, distance);
    return GSF_OK;
}

static gsf_result gsf__dense_sweeps(gsf__dense_job* job, int coarsest, int finest, double* done, double total) {
    const int32_t geometric = 2; // iterations with the geometric term, at the finest level only, after the others
    const int32_t some = finest ? (job->desc.iterations + 1) / 2 : job->desc.iterations;
    const int32_t count = coarsest ? job->desc.iterations + 2 : some;
    float scale = 1.0f;
    job->roam = coarsest;
    for (job->iteration = 0; job->iteration < count + (finest ? geometric : 0); job->iteration++, scale *= 0.5f) {
        GSF__TRY(gsf__check_cancel(job->ctx));
        if (job->iteration >= count) {
            const size_t bytes = job->pixel_count * sizeof(gsf__dense_plane);
            if (!job->others) job->others = (gsf__dense_plane*)gsf__arena_alloc(&job->level_arena, bytes, 1);
            if (!job->others) return GSF_ERROR_OUT_OF_MEMORY;
            memcpy(job->others, job->planes, bytes);
            job->roam = 0;
        }
        job->step_pixels = (coarsest ? 4.0f : 1.0f) * scale;
        job->step_normal = (coarsest ? 0.6f : 0.4f) * scale;
        if (job->step_pixels < 0.1f) job->step_pixels = 0.1f;
        if (job->step_normal < 0.05f) job->step_normal = 0.05f;
        for (job->color = 0; job->color < 2; job->color++)
            gsf__dense_run(job, gsf__dense_visit);
        *done += (double)job->pixel_count;
        gsf__progress(job->ctx, "stereo", *done < total ? *done : total, total);
    }
    return GSF_OK;
}

static gsf_result gsf__dense_match(gsf__dense_job* job, int32_t levels) {
    gsf_result result = GSF_OK;
    gsf__dense_view* coarse_views = (gsf__dense_view*)gsf_alloc_zeroed(job->ctx, job->view_count, sizeof(gsf__dense_view));
    if (!coarse_views) return GSF_ERROR_OUT_OF_MEMORY;
    double done = 0.0, total = 0.0;
    for (int32_t level = 0; level < levels; level++)
        for (size_t i = 0; i < job->view_count; i++) {
            int32_t width, height;
            gsf__dense_size(&job->scene->views[job->views[i].index].camera, job->desc.max_size, level, &width, &height);
            total += (double)width * height * (job->desc.iterations + 2);
        }
    for (int32_t level = levels - 1; level >= 0 && result == GSF_OK; level--) {
        gsf__dense_plane* coarse_planes = job->planes; // of the coarser level, NULL at the coarsest
        memcpy(coarse_views, job->views, job->view_count * sizeof *coarse_views);
        job->planes = NULL;
        gsf__dense_free_level(job);
        job->coarse_views = coarse_views;
        job->coarse_planes = coarse_planes;
        job->iteration = -1;
        result = gsf__dense_begin_level(job, level, !coarse_planes);
        if (result == GSF_OK) gsf__dense_run(job, gsf__dense_start);
        gsf_free(job->ctx, coarse_planes);
        job->coarse_planes = NULL;
        if (result == GSF_OK) result = gsf__dense_sweeps(job, level == levels - 1, level == 0, &done, total);
    }
    gsf_free(job->ctx, coarse_views);
    job->coarse_views = NULL;
    return result;
}

// ---- consistency and fusion

// Whether source s confirms the plane at a pixel: its plane there matches well and agrees in depth, reprojection and
// normal. *pixel: index of the corresponding pixel in the source view.
static int gsf__dense_confirmed(const gsf__dense_job* job, const gsf__dense_view* view, int x, int y, int s,
                                size_t* pixel) {
    const gsf__dense_plane* plane = job->planes + view->first + (size_t)y * (size_t)view->width + (size_t)x;
    const gsf__dense_source* source = view->sources + s;
    const gsf__dense_view* other = job->views + source->view;
    const float *m = source->m, *t = source->t, *bm = source->back_m, *bt = source->back_t;
    const float fx = (float)x, fy = (float)y;
    const float Z = m[6] * fx + m[7] * fy + m[8] + t[2] * plane->w;
    if (!(Z > 0.0f)) return 0;
    const float u = (m[0] * fx + m[1] * fy + m[2] + t[0] * plane->w) / Z;
    const float v = (m[3] * fx + m[4] * fy + m[5] + t[1] * plane->w) / Z;
    if (!(u > -0.5f && u < (float)other->width - 0.5f && v > -0.5f && v < (float)other->height - 0.5f)) return 0;
    const int iu = (int)(u + 0.5f), iv = (int)(v + 0.5f);
    *pixel = other->first + (size_t)iv * (size_t)other->width + (size_t)iu;
    const gsf__dense_plane* there = job->planes + *pixel;
    if (!(there->cost <= job->desc.max_cost_many)) return 0;
    const float w = there->w + there->gx * (u - (float)iu) + there->gy * (v - (float)iv), expected = plane->w / Z;
    const float difference = w < expected ? expected - w : w - expected;
    if (!(difference <= job->desc.max_depth_error * expected)) return 0;
    const float bz = bm[6] * u + bm[7] * v + bm[8] + bt[2] * w;
    if (!(bz > 0.0f)) return 0;
    const float dx = (bm[0] * u + bm[1] * v + bm[2] + bt[0] * w) / bz - fx;
    const float dy = (bm[3] * u + bm[4] * v + bm[5] + bt[1] * w) / bz - fy;
    if (!(dx * dx + dy * dy <= job->desc.max_reprojection * job->desc.max_reprojection)) return 0;
    float a[3], b[3], dot = 0.0f;
    gsf__dense_normal(view, x, y, plane, a);
    gsf__dense_normal(other, iu, iv, there, b);
    const float* r = source->rotation;
    for (int k = 0; k < 3; k++) dot += b[k] * (r[3 * k] * a[0] + r[3 * k + 1] * a[1] + r[3 * k + 2] * a[2]);
    return dot >= job->min_normal_dot;
}

static void gsf__dense_link(const gsf__dense_job* job, const gsf__dense_view* view, int x, int y) {
    const size_t at = view->first + (size_t)y * (size_t)view->width + (size_t)x;
    const float cost = job->planes[at].cost;
    int links = 0, good_links = 0, count = 0, good = 0;
    for (int s = 0; s < view->source_count && cost <= job->desc.max_cost_many; s++) {
        size_t pixel;
        if (!gsf__dense_confirmed(job, view, x, y, s, &pixel)) continue;
        links |= 1 << s;
        count++;
        if (!(cost <= job->desc.max_cost && job->planes[pixel].cost <= job->desc.max_cost)) continue;
        good_links |= 1 << s;
        good++;
    }
    if (count <= job->desc.min_consistent) links = good >= job->desc.min_consistent ? good_links : 0;
    job->links[at] = (uint8_t)links;
}

static const gsf__dense_view* gsf__dense_view_of(const gsf__dense_job* job, size_t pixel, int* x, int* y) {
    const gsf__dense_view* view = job->views;
    while (pixel - view->first >= (size_t)view->width * (size_t)view->height) view++;
    *x = (int)((pixel - view->first) % (size_t)view->width);
    *y = (int)((pixel - view->first) / (size_t)view->width);
    return view;
}

static void gsf__dense_cover(const gsf__dense_job* job, size_t pixel, int32_t spacing, uint8_t* covered) {
    int x, y;
    const gsf__dense_view* view = gsf__dense_view_of(job, pixel, &x, &y);
    const int reach = spacing - 1;
    for (int v = y > reach ? y - reach : 0; v < view->height && v <= y + reach; v++)
        for (int u = x > reach ? x - reach : 0; u < view->width && u <= x + reach; u++)
            covered[view->first + (size_t)v * (size_t)view->width + (size_t)u] = 1;
}

// Marks the pixels around the sparse points where the depths agree; where they differ, the point is occluded.
static void gsf__dense_cover_sparse(const gsf__dense_job* job, int32_t spacing, uint8_t* covered) {
    for (size_t i = 0; i < job->scene->point_count; i++)
        for (size_t k = 0; k < job->view_count && gsf__dense_usable(job, i); k++) {
            const gsf__dense_view* view = job->views + k;
            double u, v, z;
            if (!gsf__dense_in_view(&view->camera, job->scene->points + 3 * i, &u, &v, &z)) continue;
            const size_t pixel = view->first + (size_t)v * (size_t)view->width + (size_t)u;
            const double w = (double)job->planes[pixel].w;
            if (fabs(1.0 / z - w) <= 2.0 * (double)job->desc.max_depth_error * w)
                gsf__dense_cover(job, pixel, spacing, covered);
        }
}

// Chooses the pixels that become points, best match first. Each one marks all pixels closer than `spacing`, in its own
// view and around the corresponding pixels of the views that confirm it, so that none of those is chosen later.
static size_t gsf__dense_thin(const gsf__dense_job* job, const uint32_t* order, size_t count, int32_t spacing,
                              uint8_t* covered, uint32_t* chosen) {
    size_t n = 0;
    memset(covered, 0, job->pixel_count);
    if (job->desc.skip_sparse) gsf__dense_cover_sparse(job, spacing, covered);
    for (size_t i = 0; i < count; i++) {
        if (covered[order[i]]) continue;
        int x, y;
        const gsf__dense_view* view = gsf__dense_view_of(job, order[i], &x, &y);
        gsf__dense_cover(job, order[i], spacing, covered);
        for (int s = 0; s < view->source_count; s++) {
            size_t pixel;
            if ((job->links[order[i]] >> s & 1) && gsf__dense_confirmed(job, view, x, y, s, &pixel))
                gsf__dense_cover(job, pixel, spacing, covered);
        }
        chosen[n++] = order[i];
    }
    return n;
}

// World position of a pixel's plane, and its world normal, pointing towards the camera.
static void gsf__dense_locate(const gsf__dense_job* job, size_t pixel, double point[3], double normal[3]) {
    int x, y;
    const gsf__dense_view* view = gsf__dense_view_of(job, pixel, &x, &y);
    const gsf__dense_plane* plane = job->planes + pixel;
    const double z = 1.0 / (double)plane->w;
    const gsf_camera* camera = &view->camera;
    const double ray[3] = {(x + 0.5 - camera->cx) / camera->fx * z, (y + 0.5 - camera->cy) / camera->fy * z, z};
    double c2w[16];
    float n[3];
    gsf_get_camera_c2w(camera, c2w);
    gsf__dense_normal(view, x, y, plane, n);
    for (int k = 0; k < 3; k++) {
        point[k] = c2w[12 + k];
        normal[k] = 0.0;
        for (int a = 0; a < 3; a++) {
            point[k] += c2w[4 * a + k] * ray[a];
            normal[k] -= c2w[4 * a + k] * (double)n[a];
        }
    }
}

static void gsf__dense_merge(const gsf__dense_job* job, size_t pixel, gsf_dense* out, size_t row) {
    size_t pixels[1 + GSF__DENSE_SOURCES];
    int count = 1, x, y;
    const gsf__dense_view* view = gsf__dense_view_of(job, pixel, &x, &y);
    pixels[0] = pixel;
    for (int s = 0; s < view->source_count; s++)
        if ((job->links[pixel] >> s & 1) && gsf__dense_confirmed(job, view, x, y, s, pixels + count)) count++;
    double mean[3] = {0.0, 0.0, 0.0}, normal[3] = {0.0, 0.0, 0.0};
    int color[3] = {0, 0, 0};
    for (int i = 0; i < count; i++) {
        double p[3], n[3];
        gsf__dense_locate(job, pixels[i], p, n);
        const gsf__dense_view* seen = gsf__dense_view_of(job, pixels[i], &x, &y);
        const uint8_t* rgb = (const uint8_t*)seen->color.data + 3 * (pixels[i] - seen->first);
        for (int k = 0; k < 3; k++) {
            mean[k] += p[k] / count;
            normal[k] += n[k];
            color[k] += rgb[k];
        }
    }
    const double length = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
    for (int k = 0; k < 3; k++) {
        out->points[3 * row + (size_t)k] = mean[k];
        out->normals[3 * row + (size_t)k] = (float)(normal[k] / (length > 0.0 ? length : 1.0));
        out->colors[3 * row + (size_t)k] = (uint8_t)((color[k] + count / 2) / count);
    }
    out->confidence[row] = 1.0f - job->planes[pixel].cost;
    out->view_counts[row] = (uint8_t)count;
}

static gsf_result gsf__dense_make_maps(const gsf__dense_job* job, gsf__arena* arena, gsf_dense* out) {
    out->maps = (gsf_dense_map*)gsf__arena_alloc_zeroed(arena, job->view_count, sizeof(gsf_dense_map));
    if (!out->maps) return GSF_ERROR_OUT_OF_MEMORY;
    out->map_count = job->view_count;
    for (size_t i = 0; i < job->view_count; i++) {
        const gsf__dense_view* view = job->views + i;
        const size_t pixels = (size_t)view->width * (size_t)view->height;
        gsf_dense_map* map = out->maps + i;
        map->view = view->index;
        map->camera = view->camera;
        map->depth = (float*)gsf__arena_alloc_zeroed(arena, pixels, sizeof(float));
        map->normals = (float*)gsf__arena_alloc_zeroed(arena, pixels, 3 * sizeof(float));
        if (arena->failed) return GSF_ERROR_OUT_OF_MEMORY;
        for (size_t k = 0; k < pixels; k++) {
            double point[3], normal[3];
            if (!job->links[view->first + k]) continue;
            gsf__dense_locate(job, view->first + k, point, normal);
            map->depth[k] = 1.0f / job->planes[view->first + k].w;
            for (int a = 0; a < 3; a++) map->normals[3 * k + (size_t)a] = (float)normal[a];
        }
    }
    return GSF_OK;
}

// Pixels of weight below one half get no depth and confirm none.
static void gsf__dense_hide(gsf__dense_job* job) {
    for (size_t i = 0; i < job->view_count; i++) {
        const gsf__dense_view* view = job->views + i;
        const uint8_t* weight = (const uint8_t*)view->weight.data;
        for (size_t k = 0; weight && k < (size_t)view->width * (size_t)view->height; k++)
            if (weight[k] < 128) job->planes[view->first + k].cost = GSF__DENSE_BAD;
    }
}

static gsf_result gsf__dense_fuse(gsf__dense_job* job, gsf__arena* arena, gsf_dense* out, gsf_dense_stats* stats) {
    enum { BINS = 64 };
    size_t starts[BINS + 1], count = 0, n = 0;
    job->links = (uint8_t*)gsf__arena_alloc(&job->level_arena, job->pixel_count, 1);
    if (!job->links) return GSF_ERROR_OUT_OF_MEMORY;
    job->min_normal_dot = (float)gsf__cos_f64((double)job->desc.max_normal_angle * 0.017453292519943295);
    gsf__dense_hide(job);
    gsf__dense_run(job, gsf__dense_link);
    memset(starts, 0, sizeof starts);
    for (size_t i = 0; i < job->pixel_count; i++) {
        const float cost = job->planes[i].cost;
        stats->pixels += cost < GSF__DENSE_BAD;
        stats->matched += cost <= job->desc.max_cost_many;
        if (!job->links[i]) continue;
        starts[1 + (size_t)(cost / job->desc.max_cost_many * ((float)BINS - 0.5f))]++;
        count++;
    }
    stats->consistent = count;
    for (int b = 0; b < BINS; b++) starts[b + 1] += starts[b];
    uint32_t* order = (uint32_t*)gsf__arena_alloc(&job->level_arena, count, sizeof(uint32_t));
    uint32_t* chosen = (uint32_t*)gsf__arena_alloc(&job->level_arena, count, sizeof(uint32_t));
    uint8_t* covered = (uint8_t*)gsf__arena_alloc(&job->level_arena, job->pixel_count, 1);
    if (job->level_arena.failed) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < job->pixel_count; i++)
        if (job->links[i])
            order[starts[(size_t)(job->planes[i].cost / job->desc.max_cost_many * ((float)BINS - 0.5f))]++] = (uint32_t)i;
    stats->spacing = job->desc.spacing;
    n = gsf__dense_thin(job, order, count, stats->spacing, covered, chosen);
    while (job->desc.max_points && n > job->desc.max_points && stats->spacing < 1024)
        n = gsf__dense_thin(job, order, count, ++stats->spacing, covered, chosen);
    if (job->desc.max_points && n > job->desc.max_points) n = job->desc.max_points;
    out->points = (double*)gsf__arena_alloc(arena, n, 3 * sizeof(double));
    out->normals = (float*)gsf__arena_alloc(arena, n, 3 * sizeof(float));
    out->colors = (uint8_t*)gsf__arena_alloc(arena, n, 3);
    out->confidence = (float*)gsf__arena_alloc(arena, n, sizeof(float));
    out->view_counts = (uint8_t*)gsf__arena_alloc(arena, n, 1);
    if (arena->failed) return GSF_ERROR_OUT_OF_MEMORY;
    out->count = n;
    for (size_t i = 0; i < n; i++) gsf__dense_merge(job, chosen[i], out, i);
    return job->desc.want_maps ? gsf__dense_make_maps(job, arena, out) : GSF_OK;
}

// Removes duplicates from the list of views and finds the depth range and the sources of each. *pairs: number of (view,
// source) pairs.
static gsf_result gsf__dense_prepare(gsf__dense_job* job, const uint32_t* views, size_t view_count, size_t* pairs) {
    gsf_context* ctx = job->ctx;
    const size_t room = job->scene->point_count > view_count ? job->scene->point_count : view_count;
    double* scratch = (double*)gsf_alloc(ctx, room ? room : 1, sizeof(double));
    job->views = (gsf__dense_view*)gsf_alloc_zeroed(ctx, view_count ? view_count : 1, sizeof(gsf__dense_view));
    if (!scratch || !job->views) {
        gsf_free(ctx, scratch);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    for (size_t i = 0; i < view_count; i++) {
        size_t k = 0;
        while (k < job->view_count && job->views[k].index != views[i]) k++;
        if (k < job->view_count) continue;
        job->views[k].index = views[i];
        job->views[k].camera = job->scene->views[views[i]].camera;
        job->view_count++;
    }
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < job->view_count && job->view_count > 1 && result == GSF_OK; i++) {
        double low, high;
        gsf__dense_range(job, job->views + i, scratch, &low, &high);
        gsf__dense_choose_sources(job, i, low, high, scratch);
        *pairs += (size_t)job->views[i].source_count;
        result = gsf__check_cancel(ctx);
    }
    gsf_free(ctx, scratch);
    return result;
}

GSF_API void gsf_splat_destroy_dense(gsf_context* ctx, gsf_dense* dense) {
    gsf__arena arena = {ctx, dense->owned, 0};
    gsf__arena_free(&arena);
    memset(dense, 0, sizeof *dense);
}

GSF_API gsf_result gsf_splat_make_dense(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                        size_t view_count, const uint8_t* keep, const gsf_dense_desc* desc,
                                        gsf_dense* out, gsf_dense_stats* stats) {
    gsf_dense_stats counted;
    memset(&counted, 0, sizeof counted);
    memset(out, 0, sizeof *out);
    if (stats) *stats = counted;
    const gsf_dense_desc d = gsf__dense_desc_defaults(desc);
    GSF__TRY(gsf__dense_check(ctx, scene, views, view_count, &d));
    gsf__dense_job* job = (gsf__dense_job*)gsf_alloc_zeroed(ctx, 1, sizeof(gsf__dense_job));
    if (!job) return GSF_ERROR_OUT_OF_MEMORY;
    job->ctx = job->level_arena.ctx = ctx;
    job->scene = scene;
    job->desc = d;
    job->keep = keep;
    job->cost_fns[0] = GSF__LANE_KERNEL_OF(ctx->cpu_level, gsf__dense_cost_grey);
    job->cost_fns[1] = GSF__LANE_KERNEL_OF(ctx->cpu_level, gsf__dense_cost_color);
    gsf__dense_make_window(&d, &job->window);
    double start = gsf__seconds();
    gsf_result result = gsf__dense_prepare(job, views, view_count, &counted.pairs);
    counted.views = job->view_count;
    counted.seconds_prepare = gsf__seconds() - start;
    start += counted.seconds_prepare;
    int32_t levels = 1;
    for (; levels < d.levels; levels++) {
        int fits = 1;
        for (size_t i = 0; i < job->view_count; i++) {
            int32_t width, height;
            gsf__dense_size(&job->scene->views[job->views[i].index].camera, d.max_size, levels, &width, &height);
            fits &= width >= GSF__DENSE_COARSEST && height >= GSF__DENSE_COARSEST;
        }
        if (!fits) break;
    }
    if (result == GSF_OK && counted.pairs) result = gsf__dense_match(job, levels);
    counted.seconds_match = gsf__seconds() - start;
    start += counted.seconds_match;
    gsf__arena arena = {ctx, NULL, 0};
    if (result == GSF_OK && counted.pairs) result = gsf__dense_fuse(job, &arena, out, &counted);
    out->owned = arena.last;
    counted.seconds_fuse = gsf__seconds() - start;
    if (result == GSF_OK && !counted.pairs)
        gsf_log(ctx, GSF_LOG_WARNING, "dense points: none, because no two of the %zu views overlap", job->view_count);
    gsf__dense_free_level(job);
    gsf_free(ctx, job->views);
    gsf_free(ctx, job);
    if (result != GSF_OK) gsf_splat_destroy_dense(ctx, out);
    else if (stats) *stats = counted;
    return result;
}

// ---- >>rasterizer state --------------------------------------------------------

/* Stages of a frame:
       project   every splat -> one 64-byte record (screen ellipse, colour), with radius 0 if it is not drawn
       sort      the drawn splats by depth, ties by index (radix sort of the float's bits)
       bin       append each splat, in that order, to the lists of the 16x16 tiles that its ellipse overlaps; each entry
                 owns a slot for that tile's share of the splat's gradient
       forward   per tile: blend front to back, in steps of 4 x 2 pixels or, with AVX-512, 4 x 4
       backward  per tile: repeat forward, keeping alpha and T of every step; then go back to front
       gather    per splat: sum its slots in tile order, then backpropagate through the projection to the parameters
   Each stage is a parallel loop over chunks whose number depends only on sizes, never on the number of workers, and
   every sum has a fixed order. */

enum {
    GSF__TILE = 16,
    GSF__TILE_PIXELS = GSF__TILE * GSF__TILE,
    GSF__STRIP = 4,                      // columns of a strip
    GSF__STEPS = GSF__TILE_PIXELS / 8,   // a step is 4 columns and 2 rows: splats are compact, so that this shape needs
                                         // fewer steps than 8 pixels of a row
    GSF__TOGETHER = 32,                  // list entries that are found together and blended step by step
    GSF__PROJECT_CHUNK = 256,            // splats
    GSF__BUCKET = 4096,                  // steps that backward keeps at a time, plus the rest of the last entries
    GSF__KEPT_MOST = GSF__BUCKET + GSF__TOGETHER * GSF__STEPS,
};

// Slot layout. Sums over pixels, where p = dL/d(ln alpha), w = alpha*T, (e, dy) is the pixel's position in the record's
// coordinates and D = sum(w z):
enum {
    GSF__SLOT_P, GSF__SLOT_E, GSF__SLOT_EE, GSF__SLOT_Y, GSF__SLOT_EY, GSF__SLOT_YY, // sums of p times 1 e ee dy e*dy dy*dy
    GSF__SLOT_R, GSF__SLOT_G, GSF__SLOT_B, GSF__SLOT_Z,                              // sums of w times dL/dcolor, dL/dD
    GSF__SLOT_ABS_X, GSF__SLOT_ABS_Y,                                                // sums of |dL/du|, |dL/dv|
    GSF__SLOT_SUMS,
    GSF__SLOT_FLOATS = 16, // a cache line
};

#define GSF__ALPHA_MAX 0.99f
#define GSF__ALPHA_MIN (1.0f / 255.0f)
#define GSF__T_MIN 1e-4f
#define GSF__BLUR 0.3f
#define GSF__LOG2_ALPHA_MIN (-7.99435344f)
#define GSF__AA_FLOOR 2.5e-5f // lower bound of the squared antialiasing compensation

// The ellipse, in sheared coordinates that lose no precision for needle-shaped splats: with dy = y - v and
// e = (x - u) - kx*dy the exponent is a sum of two negative squares, log2(alpha) = ee*e*e + yy*dy*dy + log2_opacity.
// The ellipse covers |e| <= sqrt(h0 - h1*dy*dy) of a row. In an image 2000 pixels wide a float resolves positions to
// only 1e-4 of a pixel, which shows on the flanks of small splats; so u and v have a low-order float each.
typedef struct gsf__record {
    float u, v;            // pixel centres are at integers here (COLMAP coordinate minus 0.5)
    float kx, ee, yy, log2_opacity;
    float h0, h1;
    float r, g, b, depth;
    float reach_x;         // half width of the region with alpha >= 1/255; for the half height see gsf__reach_y
    float u_low, v_low;    // low-order parts of u and v
    int32_t radius;        // 3 sigma in pixels, as in the Inria 3DGS code; 0 = not drawn
} gsf__record;

typedef struct gsf__tile_rect { int32_t x0, y0, x1, y1; } gsf__tile_rect; // tiles, end exclusive
typedef struct gsf__tile_span { int32_t x0, x1; } gsf__tile_span;                 // of a tile row, end exclusive
enum { GSF__SPANS = 8 }; // tile rows of which spans are found together; a multiple of the number of lanes

typedef struct gsf__step { // kept by backward per splat and 8 pixels
    float alpha[8];        // before the 0.99 clamp; 0 where not blended
    float T[8];            // transmittance in front of the splat
} gsf__step;

typedef struct gsf__wide_step { float alpha[16], T[16]; } gsf__wide_step; // the same, by kernels with 16 lanes

typedef struct gsf__step_head { uint32_t entry; uint32_t step; } gsf__step_head;

typedef struct gsf__worker_scratch { // one per worker
    gsf__step* steps;          // (GSF__KEPT_MOST)
    gsf__step_head* heads;     // of the steps
    float* checkpoints;        // T of the tile's pixels at the start of each bucket
    uint32_t* checkpoint_entry; // the list entry that each bucket starts with
} gsf__worker_scratch;

struct gsf_rasterizer {
    size_t splat_capacity;
    gsf__record* records;      // per splat
    int32_t* radii;            // per splat
    size_t* splat_begin;       // (splats + 1) start of each splat's part of splat_entries
    uint64_t *order, *order_spare; // depth bits << 32 | index of each splat, in order of depth; scratch of the sort
    gsf__tile_span* rows;      // of the splat at each place of the order: first tile row and one past the last
    size_t drawn_count;        // at the start of the order
    size_t digit_capacity;
    uint32_t* digits;          // (chunks, 2^GSF__ORDER_BITS) while sorting: of each value of the key's digit

    size_t tile_capacity;      // of tile_begin
    size_t* tile_begin;        // (tiles + 1) start of each tile's list
    size_t count_capacity;
    uint32_t* tile_counts;     // (chunks, tiles) while binning
    size_t span_capacity;
    gsf__tile_span* spans;     // of each splat's tile rows, while binning
    size_t entry_count, entry_capacity;
    uint32_t* entries;         // the lists: the splats of each tile, front to back
    uint32_t* splat_entries;   // the indices of each splat in `entries`, in tile order
    size_t slot_capacity;
    float* slots;              // (entries, GSF__SLOT_FLOATS) gradient of each entry
    uint8_t* slot_used;        // (entries) 1 if backward blended the splat into some pixel and filled the slot

    size_t pixel_capacity;
    float* final_T;            // per pixel, of the last render
    float* depth_sum;          // per pixel, of the last render: sum of weight times depth
    double* tile_background;   // (tiles, 3)
    size_t tile_background_capacity;

    int32_t worker_count;
    size_t checkpoint_capacity; // of each worker
    gsf__worker_scratch* workers;
    gsf__arena worker_arena;    // the workers and their arrays

    // the last render
    int32_t width, height, tiles_x, tiles_y, sh_bands;
    size_t splat_count;
    int has_depth;

    // Set by the trainer (lazy Adam), else NULL. Called before the SH of `splat` and of the splats after it up to the
    // next multiple of 16 are read, if any of them is drawn. May be called for different chunks at the same time.
    void (*wake)(void* user, size_t splat);
    void* wake_user;
};

GSF_API gsf_result gsf_splat_make_rasterizer(gsf_context* ctx, gsf_rasterizer** out) {
    *out = (gsf_rasterizer*)gsf_alloc_zeroed(ctx, 1, sizeof(gsf_rasterizer));
    return *out ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

GSF_API void gsf_splat_destroy_rasterizer(gsf_context* ctx, gsf_rasterizer* r) {
    if (!r) return;
    void* const owned[] = {r->records, r->radii, r->splat_begin, r->order, r->order_spare, r->rows, r->digits, r->tile_begin,
                           r->tile_counts, r->spans, r->entries, r->splat_entries, r->slots, r->slot_used, r->final_T,
                           r->depth_sum, r->tile_background};
    for (size_t i = 0; i < GSF__COUNT(owned); i++) gsf_free(ctx, owned[i]);
    r->worker_arena.ctx = ctx;
    gsf__arena_free(&r->worker_arena);
    gsf_free(ctx, r);
}

// ---- >>project -----------------------------------------------------------------

// exp and log2 with the same bits on every machine; relative error below 1.2e-7 (a double result rounded to float).
static float gsf__exp(float x) {
    if (!(x > -87.0f)) return x != x ? x : 0.0f;
    if (x > 88.0f) return INFINITY;
    const double k = floor((double)x * 1.4426950408889634 + 0.5);
    const double r = (double)x - k * 0.6931471805599453;
    double p = 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    const int64_t bits = ((int64_t)k + 1023) << 52;
    double scale;
    memcpy(&scale, &bits, sizeof scale);
    return (float)(p * scale);
}

static float gsf__log2(float x) { // x > 0, normal
    int64_t bits;
    double d = (double)x;
    memcpy(&bits, &d, sizeof bits);
    int64_t e = (bits >> 52) - 1023;
    bits = (bits & 0xfffffffffffffLL) | 0x3ff0000000000000LL;
    memcpy(&d, &bits, sizeof d);
    if (d > 1.4142135623730951) {
        d *= 0.5;
        e++;
    }
    const double t = (d - 1.0) / (d + 1.0), t2 = t * t; // ln d = 2 atanh(t), |t| < 0.1716
    double p = 1.0 / 11.0;
    p = p * t2 + 1.0 / 9.0;
    p = p * t2 + 1.0 / 7.0;
    p = p * t2 + 1.0 / 5.0;
    p = p * t2 + 1.0 / 3.0;
    p = p * t2 + 1.0;
    return (float)((double)e + 2.8853900817779268 * t * p);
}

static float gsf__sigmoid(float x) {
    const float e = gsf__exp(x < 0.0f ? x : -x); // no overflow on either side
    return x < 0.0f ? e / (1.0f + e) : 1.0f / (1.0f + e);
}

typedef struct gsf__view { // constants of a frame
    double rotation[9], t[3]; // world (relative to the splats' origin) to camera
    double focal[2], middle[2]; // fx fy, and cx cy minus 0.5
    float W[9], fx, fy;     // rotation and focal, rounded
    float limit_x, limit_y; // x/z and y/z in the Jacobian are clamped to +- these
    float near_plane, opacity_scale;
    float center[3], center_low[3]; // camera centre relative to the splats' origin; high and low part, to be added
    float background[3];
    int32_t width, height, sh_coefficients;
    int antialiased, official_footprint, official_gradient;
} gsf__view;

// The remainder of x after rounding to the float `high`. Not inlined because of a bug in gcc 12: the SLP vectoriser
// (-O2) merges two adjacent splits into one of two lanes, and value numbering then folds (double2)(float2)x into x, as
// if the conversion did not round, so that the remainder becomes 0.
static GSF__NOINLINE float gsf__low_part(double x, float high) { return (float)(x - (double)high); }

static gsf__view gsf__make_view(const gsf_splats* splats, const gsf_camera* camera, const gsf_render_desc* desc) {
    gsf__view view;
    memset(&view, 0, sizeof view);
    double origin_in_camera[3], center[3];
    gsf__camera_transform(camera, splats->origin, origin_in_camera);
    gsf_get_camera_center(camera, center);
    for (int r = 0; r < 3; r++) {
        for (int c = 0; c < 3; c++) {
            view.rotation[3 * r + c] = camera->w2c[4 * c + r];
            view.W[3 * r + c] = (float)camera->w2c[4 * c + r];
        }
        view.t[r] = origin_in_camera[r];
        view.center[r] = (float)(center[r] - splats->origin[r]);
        view.center_low[r] = gsf__low_part(center[r] - splats->origin[r], view.center[r]);
        view.background[r] = desc->background[r];
    }
    view.fx = (float)(view.focal[0] = camera->fx);
    view.fy = (float)(view.focal[1] = camera->fy);
    view.middle[0] = camera->cx - 0.5;
    view.middle[1] = camera->cy - 0.5;
    view.limit_x = (float)(1.3 * camera->width / (2.0 * camera->fx));
    view.limit_y = (float)(1.3 * camera->height / (2.0 * camera->fy));
    view.near_plane = desc->near_plane > 0.0f ? desc->near_plane : 0.2f;
    view.opacity_scale = desc->opacity_scale > 0.0f ? desc->opacity_scale : 1.0f;
    view.width = camera->width;
    view.height = camera->height;
    const int32_t bands = desc->sh_bands > 0 ? desc->sh_bands : splats->sh_degree + 1;
    const int32_t used = bands < splats->sh_degree + 1 ? bands : splats->sh_degree + 1;
    view.sh_coefficients = used * used;
    view.antialiased = desc->antialiased != 0;
    view.official_footprint = desc->footprint == GSF_FOOTPRINT_OFFICIAL;
    view.official_gradient = desc->gradient == GSF_GRADIENT_OFFICIAL;
    return view;
}

// Tiles by the rule of the Inria 3DGS code: those that overlap the square of half side `radius`, with the same float
// division and truncation.
static gsf__tile_rect gsf__official_rect(const gsf__record* rec, int32_t tiles_x, int32_t tiles_y) {
    const float radius = (float)rec->radius, tile = (float)GSF__TILE;
    const float lo[2] = {(rec->u - radius) / tile, (rec->v - radius) / tile};
    const float hi[2] = {(rec->u + radius + tile - 1.0f) / tile, (rec->v + radius + tile - 1.0f) / tile};
    const int32_t limit[2] = {tiles_x, tiles_y};
    int32_t box[4];
    for (int k = 0; k < 2; k++) {
        const float top = (float)limit[k];
        box[k] = lo[k] <= 0.0f ? 0 : lo[k] >= top ? limit[k] : (int32_t)lo[k];
        box[2 + k] = hi[k] <= 0.0f ? 0 : hi[k] >= top ? limit[k] : (int32_t)hi[k];
    }
    gsf__tile_rect rect = {box[0], box[1], box[2], box[3]};
    return rect;
}

// Half height of the region with alpha >= 1/255: the dy at which h0 - h1 dy^2 is zero.
static float gsf__reach_y(const gsf__record* rec) { return sqrtf(rec->h0 / rec->h1); }

#define gsf__projection GSF__V(gsf__projection)
#define gsf__v_dot GSF__V(gsf__v_dot)
#define gsf__v_minor GSF__V(gsf__v_minor)
#define gsf__v_finite GSF__V(gsf__v_finite)
#define gsf__v_any GSF__V(gsf__v_any)
#define gsf__v_column GSF__V(gsf__v_column)

// One inclusion for these, for >>bin and for >>project backward, as each takes the preprocessor through the whole file.
#define GSF__KERNELS "gsfixer_splat.h"
#define GSF__KERNELS_SPLATS
#define GSF__KERNELS_SIMD128
#define GSF__KERNELS_AVX512
#include "gsfixer.h" // compiles what follows, once per instruction set
#undef GSF__KERNELS_SPLATS

#endif // GSF__ISA
#ifdef GSF__KERNELS_SPLATS

// Intermediate results of the projection that backward needs again. One splat per lane.
typedef struct gsf__projection {
    gsf__vf t[3];                   // mean in camera space
    gsf__vf u, v, u_low, v_low;     // mean on the screen, as in gsf__record
    gsf__vf x, y;                   // t.x / t.z, t.y / t.z after the frustum clamp
    gsf__vm clamped_x, clamped_y;
    gsf__vf q[4], inv_norm;         // unit quaternion
    gsf__vf scale[3];
    gsf__vf T[9];                   // W R S, row-major
    gsf__vf V[6];                   // J T: two rows, so that cov2d = V V^T before the blur
    gsf__vf cov_a, cov_b, cov_c, det_raw, det; // blurred covariance [[a,b],[b,c]]; determinant without and with blur
    gsf__vf logit, opacity, compensation; // opacity: sigmoid * opacity_scale; compensation: antialiasing factor
} gsf__projection;

#if GSF__LANES == 1
GSF__V_INLINE float GSF__V(gsf__exp)(float x) { return gsf__exp(x); }
GSF__V_INLINE float GSF__V(gsf__log2)(float x) { return gsf__log2(x); }
GSF__V_INLINE double GSF__V(gsf__low)(double x, float high, int h) { return h ? 0.0 : (double)gsf__low_part(x, high); }
#else

// The remainder of x after rounding to half h of `high`.
GSF__V_INLINE gsf__vd GSF__V(gsf__low)(gsf__vd x, gsf__vf high, int h) { return x - gsf__vd_half(high, h); }

// e^x with x clamped to [-87, 88]; relative error below 2e-7. Propagates NaN.
GSF__V_INLINE gsf__vf GSF__V(gsf__exp)(gsf__vf x) {
    x = gsf__v_min(gsf__v_set(88.0f), gsf__v_max(gsf__v_set(-87.0f), x));
    const gsf__vf k = gsf__v_round(x * gsf__v_set(1.44269504f));
    gsf__vf r = gsf__v_nmadd(k, gsf__v_set(0.693359375f), x); // ln 2 as a sum; k times the first part is exact
    r = gsf__v_nmadd(k, gsf__v_set(-2.12194440e-4f), r);
    gsf__vf p = gsf__v_set(1.0f / 5040.0f);
    p = gsf__v_madd(p, r, gsf__v_set(1.0f / 720.0f));
    p = gsf__v_madd(p, r, gsf__v_set(1.0f / 120.0f));
    p = gsf__v_madd(p, r, gsf__v_set(1.0f / 24.0f));
    p = gsf__v_madd(p, r, gsf__v_set(1.0f / 6.0f));
    p = gsf__v_madd(p, r, gsf__v_set(0.5f));
    p = gsf__v_madd(p * r, r, r) + gsf__v_set(1.0f);
    return p * gsf__vi_as_floats(gsf__vi_shl(gsf__vi_add(gsf__v_to_int(k), gsf__vi_set(127)), 23));
}

// log2 of a normal x > 0, accurate to 1 ulp or 1e-7, whichever is larger.
GSF__V_INLINE gsf__vf GSF__V(gsf__log2)(gsf__vf x) {
    const gsf__vi bits = gsf__v_bits(x);
    const gsf__vi e = gsf__vi_sar(gsf__vi_sub(bits, gsf__vi_set(0x3f3504f3)), 23); // sqrt(1/2): the mantissa ends up in
    const gsf__vf m = gsf__vi_as_floats(gsf__vi_sub(bits, gsf__vi_shl(e, 23)));    // [sqrt(1/2), sqrt(2))
    const gsf__vf one = gsf__v_set(1.0f), t = (m - one) / (m + one), t2 = t * t;
    gsf__vf p = gsf__v_set(1.0f / 9.0f);
    p = gsf__v_madd(p, t2, gsf__v_set(1.0f / 7.0f));
    p = gsf__v_madd(p, t2, gsf__v_set(1.0f / 5.0f));
    p = gsf__v_madd(p, t2, gsf__v_set(1.0f / 3.0f));
    p = gsf__v_madd(p, t2, one);
    return gsf__v_madd(gsf__v_set(2.88539008f) * t, p, gsf__vi_floats(e));
}

#endif

GSF__V_INLINE gsf__vf GSF__V(gsf__sigmoid)(gsf__vf x) {
    const gsf__vf zero = gsf__v_set(0.0f), one = gsf__v_set(1.0f);
    const gsf__vf e = GSF__V(gsf__exp)(zero - gsf__v_abs(x)); // no overflow on either side
    return gsf__v_select(gsf__v_lt(x, zero), e, one) / (one + e);
}

GSF__V_INLINE gsf__vf gsf__v_dot(gsf__vf ax, gsf__vf ay, gsf__vf az, gsf__vf bx, gsf__vf by, gsf__vf bz) {
    return gsf__v_madd(ax, bx, gsf__v_madd(ay, by, az * bz));
}

GSF__V_INLINE gsf__vf gsf__v_minor(gsf__vf a, gsf__vf b, gsf__vf c, gsf__vf d) { return gsf__v_msub(a, d, b * c); }

GSF__V_INLINE gsf__vm gsf__v_finite(gsf__vf x) { return gsf__v_eq(x - x, gsf__v_set(0.0f)); }

GSF__V_INLINE int gsf__v_any(gsf__vm mask) { return gsf__vm_bits(mask) != 0; }

// Column c of the lanes' rows; a row has `stride` floats.
GSF__V_INLINE gsf__vf gsf__v_column(const float* rows, gsf__vi lane, int stride, int c) {
    return gsf__v_gather(rows + c, gsf__vi_mul(lane, gsf__vi_set(stride)));
}

// Row indices of the lanes: 0 1 2 ... Lanes past the last of `left` splats repeat it.
GSF__V_INLINE gsf__vi GSF__V(gsf__splat_lanes)(size_t left) {
    return left < GSF__LANES ? gsf__vi_min(gsf__vi_index(), gsf__vi_set((int32_t)left - 1)) : gsf__vi_index();
}

// Computes p->t, u, v, u_low and v_low, in double: float would lose precision if the camera is far from the splats'
// origin, the focal length is long or the image is large.
GSF__V_INLINE void GSF__V(gsf__place)(const gsf__view* view, const gsf__vf mean[3], gsf__projection* p) {
    gsf__vd t[3][GSF__HALVES], at[2][GSF__HALVES], low[2][GSF__HALVES];
    for (int h = 0; h < GSF__HALVES; h++) {
        gsf__vd m[3];
        for (int k = 0; k < 3; k++) m[k] = gsf__vd_half(mean[k], h);
        for (int r = 0; r < 3; r++) {
            const double* w = view->rotation + 3 * r;
            t[r][h] = gsf__vd_madd(gsf__vd_set(w[0]), m[0], gsf__vd_set(view->t[r]));
            t[r][h] = gsf__vd_madd(gsf__vd_set(w[1]), m[1], t[r][h]);
            t[r][h] = gsf__vd_madd(gsf__vd_set(w[2]), m[2], t[r][h]);
        }
        const gsf__vd inv_z = gsf__vd_set(1.0) / t[2][h];
        for (int k = 0; k < 2; k++)
            at[k][h] = gsf__vd_madd(gsf__vd_set(view->focal[k]), t[k][h] * inv_z, gsf__vd_set(view->middle[k]));
    }
    for (int r = 0; r < 3; r++) p->t[r] = gsf__vd_floats(t[r]);
    p->u = gsf__vd_floats(at[0]);
    p->v = gsf__vd_floats(at[1]);
    for (int h = 0; h < GSF__HALVES; h++) {
        low[0][h] = GSF__V(gsf__low)(at[0][h], p->u, h);
        low[1][h] = GSF__V(gsf__low)(at[1][h], p->v, h);
    }
    p->u_low = gsf__vd_floats(low[0]);
    p->v_low = gsf__vd_floats(low[1]);
}

// Unit quaternions and the inverse of their norms (0 if the norm is at most 1e-12), in double so that neither tiny nor
// huge quaternions lose precision.
GSF__V_INLINE void GSF__V(gsf__unit)(const gsf__vf raw[4], gsf__vf q[4], gsf__vf* inv_norm) {
    const gsf__vd least = gsf__vd_set(1e-12), one = gsf__vd_set(1.0);
    gsf__vd unit[4][GSF__HALVES], inverse[GSF__HALVES];
    for (int h = 0; h < GSF__HALVES; h++) {
        gsf__vd wide[4], norm2 = gsf__vd_set(0.0);
        for (int k = 0; k < 4; k++) {
            wide[k] = gsf__vd_half(raw[k], h);
            norm2 = gsf__vd_madd(wide[k], wide[k], norm2);
        }
        const gsf__vd norm = gsf__vd_sqrt(norm2), inv = one / gsf__vd_max(least, norm); // propagates NaN
        for (int k = 0; k < 4; k++) unit[k][h] = wide[k] * inv;
        inverse[h] = gsf__vd_keep_above(norm, least, inv);
    }
    for (int k = 0; k < 4; k++) q[k] = gsf__vd_floats(unit[k]);
    *inv_norm = gsf__vd_floats(inverse);
}

// Mean and covariance on the screen of the splats from i on. Returns the mask of those that are finite and in front of
// the near plane. If none is in front of it, only t, u, v, u_low and v_low are filled in.
GSF__V_KERNEL gsf__vm GSF__V(gsf__project)(const gsf__view* view, const gsf_splats* splats, size_t i, gsf__vi lane,
                                           gsf__projection* p) {
    const gsf__vf one = gsf__v_set(1.0f), two = gsf__v_set(2.0f), zero = gsf__v_set(0.0f);
    gsf__vf W[9], mean[3], raw[4];
    for (int k = 0; k < 9; k++) W[k] = gsf__v_set(view->W[k]);
    for (int k = 0; k < 3; k++) mean[k] = gsf__v_column(splats->means + 3 * i, lane, 3, k);
    GSF__V(gsf__place)(view, mean, p);
    const gsf__vm in_front = gsf__v_gt(p->t[2], gsf__v_set(view->near_plane));
    if (!gsf__v_any(in_front)) return in_front;

    for (int k = 0; k < 4; k++) raw[k] = gsf__v_column(splats->quats + 4 * i, lane, 4, k);
    GSF__V(gsf__unit)(raw, p->q, &p->inv_norm);

    gsf__vf finite = one; // else -inf would pass as a flat splat, and a logit of +inf as opaque
    for (int k = 0; k < 3; k++) {
        const gsf__vf log_scale = gsf__v_column(splats->log_scales + 3 * i, lane, 3, k);
        finite = finite + (log_scale - log_scale);
        p->scale[k] = GSF__V(gsf__exp)(log_scale);
    }
    const gsf__vf w = p->q[0], x = p->q[1], y = p->q[2], z = p->q[3];
    const gsf__vf R[9] = {one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
                          two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
                          two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)};
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++)
            p->T[3 * r + c] = gsf__v_dot(W[3 * r], W[3 * r + 1], W[3 * r + 2], R[c], R[3 + c], R[6 + c]) * p->scale[c];

    const gsf__vf inv_z = one / p->t[2], rx = p->t[0] * inv_z, ry = p->t[1] * inv_z;
    const gsf__vf limit_x = gsf__v_set(view->limit_x), limit_y = gsf__v_set(view->limit_y);
    p->clamped_x = gsf__vm_not(gsf__v_le(gsf__v_abs(rx), limit_x));
    p->clamped_y = gsf__vm_not(gsf__v_le(gsf__v_abs(ry), limit_y));
    p->x = gsf__v_max(zero - limit_x, gsf__v_min(limit_x, rx));
    p->y = gsf__v_max(zero - limit_y, gsf__v_min(limit_y, ry));
    const gsf__vf jx = gsf__v_set(view->fx) * inv_z, jy = gsf__v_set(view->fy) * inv_z;
    for (int c = 0; c < 3; c++) {
        p->V[c] = jx * gsf__v_nmadd(p->x, p->T[6 + c], p->T[c]);
        p->V[3 + c] = jy * gsf__v_nmadd(p->y, p->T[6 + c], p->T[3 + c]);
    }
    const gsf__vf* V = p->V;
    const gsf__vf a = gsf__v_dot(V[0], V[1], V[2], V[0], V[1], V[2]), b = gsf__v_dot(V[0], V[1], V[2], V[3], V[4], V[5]);
    const gsf__vf c = gsf__v_dot(V[3], V[4], V[5], V[3], V[4], V[5]), blur = gsf__v_set(GSF__BLUR);
    // determinant as the sum of squared 2x2 minors (Cauchy-Binet): no cancellation even for very thin ellipses
    const gsf__vf m0 = gsf__v_minor(V[1], V[2], V[4], V[5]), m1 = gsf__v_minor(V[2], V[0], V[5], V[3]);
    const gsf__vf m2 = gsf__v_minor(V[0], V[1], V[3], V[4]);
    p->det_raw = gsf__v_dot(m0, m1, m2, m0, m1, m2);
    p->det = p->det_raw + blur * (a + c) + blur * blur;
    p->cov_a = a + blur;
    p->cov_b = b;
    p->cov_c = c + blur;

    p->logit = gsf__v_column(splats->opacity_logits + i, lane, 1, 0);
    p->opacity = GSF__V(gsf__sigmoid)(p->logit) * gsf__v_set(view->opacity_scale);
    p->compensation = one;
    if (view->antialiased) p->compensation = gsf__v_sqrt(gsf__v_max(p->det_raw / p->det, gsf__v_set(GSF__AA_FLOOR)));
    finite = finite + (p->det + p->cov_a + p->cov_c + p->opacity + p->t[0] + p->t[1] + p->t[2] + (p->logit - p->logit));
    return gsf__vm_and(gsf__vm_and(in_front, gsf__v_finite(finite)), gsf__v_gt(p->det, zero));
}

// Real spherical harmonics in the 3DGS convention at a unit direction; writes `count` values (1, 4, 9 or 16).
GSF__V_INLINE void GSF__V(gsf__sh_basis)(gsf__vf x, gsf__vf y, gsf__vf z, int32_t count, gsf__vf basis[16]) {
    basis[0] = gsf__v_set(0.28209479177387814f);
    if (count < 4) return;
    basis[1] = gsf__v_set(-0.4886025119029199f) * y;
    basis[2] = gsf__v_set(0.4886025119029199f) * z;
    basis[3] = gsf__v_set(-0.4886025119029199f) * x;
    if (count < 9) return;
    const gsf__vf xx = x * x, yy = y * y, zz = z * z;
    const gsf__vf two = gsf__v_set(2.0f), three = gsf__v_set(3.0f), four = gsf__v_set(4.0f);
    basis[4] = gsf__v_set(1.0925484305920792f) * x * y;
    basis[5] = gsf__v_set(-1.0925484305920792f) * y * z;
    basis[6] = gsf__v_set(0.31539156525252005f) * (two * zz - xx - yy);
    basis[7] = gsf__v_set(-1.0925484305920792f) * x * z;
    basis[8] = gsf__v_set(0.5462742152960396f) * (xx - yy);
    if (count < 16) return;
    basis[9] = gsf__v_set(-0.5900435899266435f) * y * (three * xx - yy);
    basis[10] = gsf__v_set(2.890611442640554f) * x * y * z;
    basis[11] = gsf__v_set(-0.4570457994644658f) * y * (four * zz - xx - yy);
    basis[12] = gsf__v_set(0.3731763325901154f) * z * (two * zz - three * (xx + yy));
    basis[13] = gsf__v_set(-0.4570457994644658f) * x * (four * zz - xx - yy);
    basis[14] = gsf__v_set(1.445305721320277f) * z * (xx - yy);
    basis[15] = gsf__v_set(-0.5900435899266435f) * x * (xx - three * yy);
}

// Unit directions from the camera centre to the means. Returns the distances; where one is 0, the direction is 0 0 1.
GSF__V_INLINE gsf__vf GSF__V(gsf__view_direction)(const gsf__view* view, const gsf_splats* splats, size_t i, gsf__vi lane,
                                                  gsf__vf d[3]) {
    for (int k = 0; k < 3; k++) {
        const gsf__vf mean = gsf__v_column(splats->means + 3 * i, lane, 3, k);
        d[k] = (mean - gsf__v_set(view->center[k])) - gsf__v_set(view->center_low[k]);
    }
    const gsf__vf length = gsf__v_sqrt(gsf__v_dot(d[0], d[1], d[2], d[0], d[1], d[2]));
    const gsf__vm apart = gsf__v_gt(length, gsf__v_set(0.0f));
    const gsf__vf inv = gsf__v_keep(apart, gsf__v_set(1.0f) / length);
    for (int k = 0; k < 3; k++) d[k] = d[k] * inv;
    d[2] = gsf__v_select(apart, d[2], gsf__v_set(1.0f));
    return gsf__v_keep(apart, length);
}

// Loads the first `count` floats of each lane's SH row, transposed to columns.
GSF__V_INLINE void GSF__V(gsf__sh_columns)(const gsf_splats* splats, size_t i, gsf__vi lane, int count, gsf__vf sh[48]) {
    const int stored = 3 * gsf_splat_count_sh(splats->sh_degree);
    const float* rows = splats->sh + (size_t)stored * i;
    int32_t at[GSF__LANES];
    int k = 0;
    gsf__vi_store(at, lane);
    for (; k < count && k + GSF__LANES <= stored; k += GSF__LANES) {
        for (int l = 0; l < GSF__LANES; l++) sh[k + l] = gsf__v_load(rows + stored * at[l] + k);
        gsf__v_transpose(sh + k);
    }
    for (; k < count; k++) sh[k] = gsf__v_column(rows, lane, stored, k);
}

GSF__V_INLINE void GSF__V(gsf__colors)(const gsf__view* view, const gsf_splats* splats, size_t i, gsf__vi lane,
                                       gsf__vf rgb[3]) {
    gsf__vf d[3], basis[16], sh[48];
    (void)GSF__V(gsf__view_direction)(view, splats, i, lane, d);
    GSF__V(gsf__sh_basis)(d[0], d[1], d[2], view->sh_coefficients, basis);
    GSF__V(gsf__sh_columns)(splats, i, lane, 3 * view->sh_coefficients, sh);
    for (int c = 0; c < 3; c++) {
        rgb[c] = gsf__v_set(0.5f);
        for (int32_t k = 0; k < view->sh_coefficients; k++) rgb[c] = gsf__v_madd(basis[k], sh[3 * k + c], rgb[c]);
    }
}

// Whether center +- radius overlaps any of `tiles` tiles along one axis, by the rule of gsf__official_rect.
GSF__V_INLINE gsf__vm GSF__V(gsf__official_meets)(gsf__vf center, gsf__vf radius, int32_t tiles) {
    const gsf__vf tile = gsf__v_set((float)GSF__TILE), most = gsf__v_set((float)tiles), zero = gsf__v_set(0.0f);
    const gsf__vf lo = (center - radius) / tile, hi = (center + radius + tile - gsf__v_set(1.0f)) / tile;
    return gsf__v_lt(gsf__v_floor(gsf__v_min(gsf__v_max(lo, zero), most)),
                     gsf__v_floor(gsf__v_min(gsf__v_max(hi, zero), most)));
}

// Records and radii of the splats from i on. A splat whose alpha never reaches 1/255 is not drawn. With
// GSF_FOOTPRINT_OFFICIAL it still has a radius, as in the Inria 3DGS code, and so counts as visible in densification.
GSF__V_KERNEL void GSF__V(gsf__records)(gsf_rasterizer* r, const gsf__view* view, const gsf_splats* splats,
                                        const uint8_t* hidden, size_t i, size_t left) {
    const gsf__vi lane = GSF__V(gsf__splat_lanes)(left);
    const gsf__vf one = gsf__v_set(1.0f), zero = gsf__v_set(0.0f), half = gsf__v_set(0.5f);
    const size_t count = left < GSF__LANES ? left : GSF__LANES;
    gsf__projection p;
    gsf__vm drawn = GSF__V(gsf__project)(view, splats, i, lane, &p), faint = gsf__vm_of_bits(0);
    uint32_t dropped = 0;
    for (size_t l = 0; hidden && l < count; l++) dropped |= (uint32_t)(hidden[i + l] != 0) << l;
    drawn = gsf__vm_and(drawn, gsf__vm_not(gsf__vm_of_bits(dropped)));
    gsf__vf row[16], rgb[3];
    if (gsf__v_any(drawn)) {
        const gsf__vf opacity = p.opacity * p.compensation;
        const gsf__vf log2_opacity = GSF__V(gsf__log2)(gsf__v_max(opacity, gsf__v_set(1e-30f)));
        // alpha >= 1/255 <=> mahalanobis^2 <= t2; slightly enlarged, so that rounding never drops a pixel
        const gsf__vf t2 = gsf__v_madd(gsf__v_set(2.0f * 0.69314718f * 1.0001f),
                                       log2_opacity - gsf__v_set(GSF__LOG2_ALPHA_MIN), gsf__v_set(1e-4f));
        const gsf__vf conic_a = p.cov_c / p.det, inv_c = one / p.cov_c; // conic [[a,b],[b,c]]: inverse covariance
        const gsf__vf half_gap = half * (p.cov_a - p.cov_c); // root = (half trace)^2 - det without cancellation
        const gsf__vf root = gsf__v_madd(half_gap, half_gap, p.cov_b * p.cov_b);
        const gsf__vf longest = half * (p.cov_a + p.cov_c) + gsf__v_sqrt(gsf__v_max(root, gsf__v_set(0.1f)));
        row[0] = p.u;
        row[1] = p.v;
        row[2] = p.cov_b * inv_c;
        row[3] = gsf__v_set(-0.72134752f) * conic_a; // -log2(e)/2 times a
        row[4] = gsf__v_set(-0.72134752f) * inv_c;   // (ac - b^2)/a of the conic is 1/cov_c
        row[5] = log2_opacity;
        row[6] = t2 / conic_a;
        row[7] = inv_c / conic_a;
        row[11] = p.t[2];
        row[12] = gsf__v_sqrt(t2 * p.cov_a);
        row[13] = p.u_low;
        row[14] = p.v_low;
        row[15] = gsf__v_min(gsf__v_ceil(gsf__v_set(3.0f) * gsf__v_sqrt(longest)), gsf__v_set(1e9f));
        const gsf__vm opaque = gsf__v_ge(opacity, gsf__v_set(GSF__ALPHA_MIN));
        if (view->official_footprint) {
            drawn = gsf__vm_and(drawn, gsf__v_finite(p.u + p.v));
            drawn = gsf__vm_and(drawn, GSF__V(gsf__official_meets)(p.u, row[15], r->tiles_x));
            drawn = gsf__vm_and(drawn, GSF__V(gsf__official_meets)(p.v, row[15], r->tiles_y));
            faint = gsf__vm_and(drawn, gsf__vm_not(opaque));
        } else {
            const gsf__vf reach_y = gsf__v_sqrt(t2 * p.cov_c);
            drawn = gsf__vm_and(drawn, gsf__v_ge(row[0] + row[12], zero));
            drawn = gsf__vm_and(drawn, gsf__v_le(row[0] - row[12], gsf__v_set((float)(r->width - 1))));
            drawn = gsf__vm_and(drawn, gsf__v_ge(row[1] + reach_y, zero));
            drawn = gsf__vm_and(drawn, gsf__v_le(row[1] - reach_y, gsf__v_set((float)(r->height - 1))));
        }
        drawn = gsf__vm_and(drawn, opaque);
    }
    if (!gsf__v_any(gsf__vm_or(drawn, faint))) {
        for (size_t l = 0; l < count; l++) r->radii[i + l] = r->records[i + l].radius = 0;
        return;
    }
    if (r->wake && gsf__v_any(drawn)) r->wake(r->wake_user, i);
    GSF__V(gsf__colors)(view, splats, i, lane, rgb);
    for (int c = 0; c < 3; c++) row[8 + c] = gsf__v_max(rgb[c], zero);
    gsf__vf sum = rgb[0] + rgb[1] + rgb[2] + row[0] + row[1];
    for (int k = 2; k < 15; k++) sum = sum + row[k];
    drawn = gsf__vm_and(drawn, gsf__v_finite(sum));
    const gsf__vi radius = gsf__v_to_int(row[15]);
    int32_t radii[GSF__LANES];
    gsf__vi_store(radii, gsf__vi_keep(gsf__vm_or(drawn, faint), radius));
    row[15] = gsf__vi_as_floats(gsf__vi_keep(drawn, radius));
    for (int k = 0; k < 16; k += GSF__LANES) gsf__v_transpose(row + k);
    for (size_t l = 0; l < count; l++) {
        float* out = (float*)(void*)(r->records + i + l);
        for (size_t k = 0; k < 16; k += GSF__LANES) gsf__v_store(out + k, row[k + l]);
        r->radii[i + l] = radii[l];
    }
}

#endif // GSF__KERNELS_SPLATS
#ifndef GSF__ISA

typedef struct gsf__splat_loop { // a loop over all splats
    gsf_rasterizer* r;
    const gsf__view* view;
    const gsf_splats* splats;
    const uint8_t* hidden;        // for gsf__project_chunk
    const gsf_splat_grads* grads; // for gsf__gather_chunk
    gsf_cpu_level level;
} gsf__splat_loop;

static size_t gsf__splat_chunks(const gsf_rasterizer* r) {
    return (r->splat_count + GSF__PROJECT_CHUNK - 1) / GSF__PROJECT_CHUNK;
}

static size_t gsf__splat_chunk_end(const gsf_rasterizer* r, size_t chunk) {
    const size_t end = (chunk + 1) * GSF__PROJECT_CHUNK;
    return end < r->splat_count ? end : r->splat_count;
}

// The scalar kernels implement the rules of the Inria 3DGS code as well.
static gsf_cpu_level gsf__footprint_level(const gsf__view* view, gsf_cpu_level level) {
    return view->official_footprint ? GSF_CPU_SCALAR : level;
}

static void gsf__project_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__splat_loop* job = (const gsf__splat_loop*)arg;
    const size_t end = gsf__splat_chunk_end(job->r, chunk);
    const gsf_cpu_level level = gsf__footprint_level(job->view, job->level);
    for (size_t i = chunk * GSF__PROJECT_CHUNK; i < end; i += GSF__ANY_KERNEL_OF(level, GSF__LANES))
        GSF__ANY_KERNEL_OF(level, gsf__records)(job->r, job->view, job->splats, job->hidden, i, end - i);
}

// ---- >>depth order -------------------------------------------------------------

// Sorted once by depth, the splats come to every tile's list in order.
enum { GSF__ORDER_BITS = 8, GSF__ORDER_VALUES = 1 << GSF__ORDER_BITS, GSF__ORDER_CHUNKS = 32 };

typedef struct gsf__order_job {
    gsf_rasterizer* r;
    size_t chunk_size;
    int shift; // of the digit
} gsf__order_job;

static size_t gsf__order_end(const gsf__order_job* job, size_t chunk) {
    const size_t end = (chunk + 1) * job->chunk_size;
    return end < job->r->splat_count ? end : job->r->splat_count;
}

static void gsf__order_key_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__order_job* job = (const gsf__order_job*)arg;
    for (size_t i = chunk * job->chunk_size; i < gsf__order_end(job, chunk); i++) {
        const gsf__record* rec = job->r->records + i;
        uint32_t depth = UINT32_MAX; // not drawn: at the end
        if (rec->radius > 0) memcpy(&depth, &rec->depth, sizeof depth); // positive, so its bits sort like the float
        job->r->order[i] = (uint64_t)depth << 32 | i;
    }
}

static void gsf__order_count_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__order_job* job = (const gsf__order_job*)arg;
    uint32_t* digits = job->r->digits + chunk * GSF__ORDER_VALUES;
    memset(digits, 0, GSF__ORDER_VALUES * sizeof *digits);
    for (size_t i = chunk * job->chunk_size; i < gsf__order_end(job, chunk); i++)
        digits[job->r->order[i] >> job->shift & (GSF__ORDER_VALUES - 1)]++;
}

static void gsf__order_move_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__order_job* job = (const gsf__order_job*)arg;
    uint32_t* next = job->r->digits + chunk * GSF__ORDER_VALUES;
    for (size_t i = chunk * job->chunk_size; i < gsf__order_end(job, chunk); i++) {
        const uint64_t key = job->r->order[i];
        job->r->order_spare[next[key >> job->shift & (GSF__ORDER_VALUES - 1)]++] = key;
    }
}

static gsf_result gsf__order(gsf_context* ctx, gsf_rasterizer* r) {
    gsf__order_job job;
    job.r = r;
    job.chunk_size = r->splat_count / GSF__ORDER_CHUNKS + 1;
    if (job.chunk_size < 8192) job.chunk_size = 8192;
    const size_t chunks = (r->splat_count + job.chunk_size - 1) / job.chunk_size;
    GSF__TRY(gsf__reserve(ctx, (void**)&r->digits, &r->digit_capacity, 0, chunks * GSF__ORDER_VALUES, sizeof(uint32_t)));
    gsf__parallel_for(ctx, chunks, gsf__order_key_chunk, &job);
    for (job.shift = 32; job.shift < 64; job.shift += GSF__ORDER_BITS) {
        gsf__parallel_for(ctx, chunks, gsf__order_count_chunk, &job);
        uint32_t sum = 0;
        for (size_t value = 0; value < GSF__ORDER_VALUES; value++)
            for (size_t c = 0; c < chunks; c++) { // each count becomes the index at which its chunk writes
                uint32_t* digit = r->digits + c * GSF__ORDER_VALUES + value;
                const uint32_t count = *digit;
                *digit = sum;
                sum += count;
            }
        gsf__parallel_for(ctx, chunks, gsf__order_move_chunk, &job);
        uint64_t* swap = r->order;
        r->order = r->order_spare;
        r->order_spare = swap;
    }
    size_t low = 0, high = r->splat_count; // where the splats begin that are not drawn
    while (low < high) {
        const size_t middle = (low + high) / 2;
        if (r->order[middle] >> 32 == UINT32_MAX) high = middle;
        else low = middle + 1;
    }
    r->drawn_count = low;
    return GSF_OK;
}

// ---- >>bin ---------------------------------------------------------------------

// Tile rows that the splat overlaps: first and one past the last.
static gsf__tile_span gsf__tile_rows(const gsf_rasterizer* r, const gsf__view* view, const gsf__record* rec) {
    const float reach_y = gsf__reach_y(rec);
    const float lo = ceilf(rec->v - reach_y - 0.01f), hi = floorf(rec->v + reach_y + 0.01f);
    gsf__tile_span rows = {0, 0};
    if (hi < 0.0f || lo > (float)(r->height - 1) || lo > hi) return rows;
    rows.x0 = lo <= 0.0f ? 0 : (int32_t)lo / GSF__TILE;
    rows.x1 = (hi >= (float)(r->height - 1) ? r->height - 1 : (int32_t)hi) / GSF__TILE + 1;
    if (view->official_footprint) {
        const gsf__tile_rect rect = gsf__official_rect(rec, r->tiles_x, r->tiles_y);
        if (rows.x0 < rect.y0) rows.x0 = rect.y0;
        if (rows.x1 > rect.y1) rows.x1 = rect.y1;
        if (rows.x1 < rows.x0) rows.x1 = rows.x0;
    }
    return rows;
}

#endif // GSF__ISA
#if defined(GSF__KERNELS_SPLATS) && GSF__LANES <= 8

// The tiles that the ellipse alpha >= 1/255 overlaps in the tile rows from ty on (exact up to the margins); empty if
// x1 <= x0. One tile row per lane.
GSF__V_KERNEL void GSF__V(gsf__tile_columns)(const gsf_rasterizer* r, const gsf__record* rec, int32_t ty, int32_t left,
                                             gsf__tile_span spans[GSF__SPANS]) {
    const gsf__vf zero = gsf__v_set(0.0f), tile = gsf__v_set((float)GSF__TILE), u = gsf__v_set(rec->u);
    const gsf__vf kx = gsf__v_set(rec->kx), h0 = gsf__v_set(rec->h0), h1 = gsf__v_set(rec->h1);
    const float half_height = gsf__reach_y(rec);
    const gsf__vf reach_x = gsf__v_set(rec->reach_x), reach_y = gsf__v_set(half_height);
    // dy of the rightmost point; the leftmost is at -dy
    const gsf__vf top = gsf__v_set(rec->kx * half_height * (half_height / rec->reach_x)), bottom = zero - top;
    const gsf__vf margin = gsf__v_set(0.02f), last = gsf__v_set((float)(r->width - 1));
    for (int32_t k = 0; k < GSF__SPANS && k < left; k += GSF__LANES) {
        const gsf__vf row = gsf__vi_floats(gsf__vi_add(gsf__vi_index(), gsf__vi_set(k)));
        const gsf__vf first = gsf__v_madd(row, tile, gsf__v_set((float)(ty * GSF__TILE) - rec->v));
        const gsf__vf ya = gsf__v_max(first, zero - reach_y);
        const gsf__vf yb = gsf__v_min(first + gsf__v_set((float)(GSF__TILE - 1)), reach_y);
        const gsf__vf ha = gsf__v_sqrt(gsf__v_max(gsf__v_nmadd(h1 * ya, ya, h0), zero));
        const gsf__vf hb = gsf__v_sqrt(gsf__v_max(gsf__v_nmadd(h1 * yb, yb, h0), zero));
        gsf__vf right = gsf__v_max(gsf__v_madd(kx, ya, ha), gsf__v_madd(kx, yb, hb));
        gsf__vf left_most = gsf__v_min(gsf__v_msub(kx, ya, ha), gsf__v_msub(kx, yb, hb));
        right = gsf__v_select(gsf__vm_and(gsf__v_ge(top, ya), gsf__v_le(top, yb)), reach_x, right);
        left_most = gsf__v_select(gsf__vm_and(gsf__v_ge(bottom, ya), gsf__v_le(bottom, yb)), zero - reach_x, left_most);
        const gsf__vf lo = gsf__v_ceil(u + left_most - margin), hi = gsf__v_floor(u + right + margin);
        gsf__vm met = gsf__vm_and(gsf__v_ge(hi, zero), gsf__v_le(lo, last));
        met = gsf__vm_and(met, gsf__v_le(lo, hi));
        const gsf__vi x0 = gsf__vi_sar(gsf__v_truncate(gsf__v_max(lo, zero)), 4); // GSF__TILE is 2^4
        const gsf__vi x1 = gsf__vi_add(gsf__vi_sar(gsf__v_truncate(gsf__v_min(hi, last)), 4), gsf__vi_set(1));
        gsf__vi_store_pairs(&spans[k].x0, gsf__vi_keep(met, x0), gsf__vi_keep(met, x1));
    }
}

#endif // GSF__KERNELS_SPLATS
#ifndef GSF__ISA

enum { GSF__BIN_CHUNKS = 32 };

typedef struct gsf__bin_job {
    gsf_rasterizer* r;
    const gsf__view* view;
    size_t chunk_size;
    size_t spans[GSF__BIN_CHUNKS + 1]; // of a chunk: how many; then its first one in r->spans
    gsf_cpu_level level;
} gsf__bin_job;

static void gsf__tile_spans(const gsf__bin_job* job, const gsf__record* rec, int32_t ty, int32_t left,
                            gsf__tile_span spans[GSF__SPANS]) {
    GSF__LANE_KERNEL_OF(gsf__footprint_level(job->view, job->level), gsf__tile_columns)(job->r, rec, ty, left, spans);
    if (!job->view->official_footprint) return;
    const gsf__tile_rect rect = gsf__official_rect(rec, job->r->tiles_x, job->r->tiles_y);
    for (int32_t i = 0; i < left && i < GSF__SPANS; i++) {
        if (spans[i].x0 < rect.x0) spans[i].x0 = rect.x0;
        if (spans[i].x1 > rect.x1) spans[i].x1 = rect.x1;
    }
}

static size_t gsf__bin_end(const gsf__bin_job* job, size_t chunk) {
    const size_t end = (chunk + 1) * job->chunk_size;
    return end < job->r->drawn_count ? end : job->r->drawn_count;
}

// The record at place k of the order; those are scattered over memory.
static const gsf__record* gsf__ordered(const gsf_rasterizer* r, size_t k) {
    if (k + 16 < r->drawn_count) gsf__v_fetch_scalar(&r->records[(uint32_t)r->order[k + 16]].u);
    return r->records + (uint32_t)r->order[k];
}

static void gsf__bin_measure_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    gsf__bin_job* job = (gsf__bin_job*)arg;
    const size_t end = gsf__bin_end(job, chunk);
    size_t count = GSF__SPANS; // that many are written together
    for (size_t k = chunk * job->chunk_size; k < end; k++) {
        const gsf__tile_span rows = gsf__tile_rows(job->r, job->view, gsf__ordered(job->r, k));
        job->r->rows[k] = rows;
        count += (size_t)(rows.x1 - rows.x0);
    }
    job->spans[chunk] = count;
}

static void gsf__bin_count_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__bin_job* job = (const gsf__bin_job*)arg;
    gsf_rasterizer* r = job->r;
    uint32_t* counts = r->tile_counts + chunk * (size_t)r->tiles_x * (size_t)r->tiles_y;
    gsf__tile_span* span = r->spans + job->spans[chunk];
    const size_t end = gsf__bin_end(job, chunk);
    for (size_t k = chunk * job->chunk_size; k < end; k++) {
        const gsf__record* rec = gsf__ordered(r, k);
        const gsf__tile_span rows = r->rows[k];
        size_t entries = 0;
        for (int32_t ty = rows.x0; ty < rows.x1; ty += GSF__SPANS)
            gsf__tile_spans(job, rec, ty, rows.x1 - ty, span + (ty - rows.x0));
        for (int32_t ty = rows.x0; ty < rows.x1; ty++, span++) {
            uint32_t* row = counts + (size_t)ty * (size_t)r->tiles_x;
            for (int32_t tx = span->x0; tx < span->x1; tx++, entries++) row[tx]++;
        }
        r->splat_begin[(uint32_t)r->order[k] + 1] = entries;
    }
}

static void gsf__bin_fill_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__bin_job* job = (const gsf__bin_job*)arg;
    gsf_rasterizer* r = job->r;
    uint32_t* next = r->tile_counts + chunk * (size_t)r->tiles_x * (size_t)r->tiles_y;
    const gsf__tile_span* span = r->spans + job->spans[chunk];
    const size_t end = gsf__bin_end(job, chunk);
    for (size_t k = chunk * job->chunk_size; k < end; k++) {
        const uint32_t splat = (uint32_t)r->order[k];
        uint32_t* entry = r->splat_entries + r->splat_begin[splat];
        for (int32_t ty = r->rows[k].x0; ty < r->rows[k].x1; ty++, span++) {
            uint32_t* row = next + (size_t)ty * (size_t)r->tiles_x;
            for (int32_t tx = span->x0; tx < span->x1; tx++) {
                const uint32_t at = row[tx]++;
                r->entries[at] = splat;
                *entry++ = at;
            }
        }
    }
}

static gsf_result gsf__grow(gsf_context* ctx, void** array, size_t capacity, size_t size) { // contents are not kept
    gsf_free(ctx, *array);
    *array = gsf_alloc(ctx, capacity, size);
    return *array ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

static gsf_result gsf__bin(gsf_context* ctx, gsf_rasterizer* r, const gsf__view* view) {
    const size_t tiles = (size_t)r->tiles_x * (size_t)r->tiles_y;
    gsf__bin_job job;
    job.r = r;
    job.view = view;
    job.level = ctx->cpu_level;
    job.chunk_size = r->drawn_count / GSF__BIN_CHUNKS + 1;
    if (job.chunk_size < 1024) job.chunk_size = 1024;
    const size_t chunks = (r->drawn_count + job.chunk_size - 1) / job.chunk_size;
    GSF__TRY(gsf__reserve(ctx, (void**)&r->tile_begin, &r->tile_capacity, 0, tiles + 1, sizeof(size_t)));
    GSF__TRY(gsf__reserve(ctx, (void**)&r->tile_counts, &r->count_capacity, 0, chunks * tiles, sizeof(uint32_t)));
    if (chunks) memset(r->tile_counts, 0, chunks * tiles * sizeof(uint32_t));
    memset(r->splat_begin, 0, (r->splat_count + 1) * sizeof *r->splat_begin);
    gsf__parallel_for(ctx, chunks, gsf__bin_measure_chunk, &job);
    size_t spans = 0, total = 0;
    for (size_t c = 0; c < chunks; c++) {
        const size_t n = job.spans[c];
        job.spans[c] = spans;
        spans += n;
    }
    GSF__TRY(gsf__reserve(ctx, (void**)&r->spans, &r->span_capacity, 0, spans, sizeof(gsf__tile_span)));
    gsf__parallel_for(ctx, chunks, gsf__bin_count_chunk, &job);

    for (size_t t = 0; t < tiles; t++) { // prefix sums: each count becomes the index at which its chunk writes
        r->tile_begin[t] = total;
        for (size_t c = 0; c < chunks; c++) {
            const uint32_t n = r->tile_counts[c * tiles + t];
            r->tile_counts[c * tiles + t] = (uint32_t)total;
            total += n;
        }
    }
    if (total > UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "rasterizer: %zu pairs of splats and tiles do not fit 32 bits", total);
    r->tile_begin[tiles] = total;
    for (size_t i = 0; i < r->splat_count; i++) r->splat_begin[i + 1] += r->splat_begin[i];
    r->entry_count = total;
    if (total > r->entry_capacity || !r->splat_entries) { // allocated even if empty: never NULL
        const size_t capacity = total + total / 4;
        r->entry_capacity = 0;
        GSF__TRY(gsf__grow(ctx, (void**)&r->entries, capacity, sizeof(uint32_t)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->splat_entries, capacity, sizeof(uint32_t)));
        r->entry_capacity = capacity;
    }
    gsf__parallel_for(ctx, chunks, gsf__bin_fill_chunk, &job);
    return GSF_OK;
}

// ---- >>raster forward ----------------------------------------------------------

/* A tile's pixels are stored as four strips of 4 columns; a strip is 8 steps of 4 columns and 2 rows, in which the two
   rows alternate: arrays [strip][pair of rows][column][row]. So step s is in strip s >> 3 and rows 2*(s & 7) and the next.
   With 16 lanes, a step is a block of 4 x 4 pixels. T > 0: the pixel is still open; T < 0: it is finished, and |T| is its
   final transmittance. `live` has a bit set for every step that has an open pixel. */
typedef struct gsf__tile {
    const gsf__record* records; // per splat
    const uint32_t* splats;     // the tile's list, front to back
    size_t count;
    float x0, y0;            // of the tile's first pixel
} gsf__tile;

typedef struct gsf__tile_state {
    GSF__LINES float T[GSF__TILE_PIXELS];
    float r[GSF__TILE_PIXELS], g[GSF__TILE_PIXELS], b[GSF__TILE_PIXELS], z[GSF__TILE_PIXELS];
} gsf__tile_state;

typedef struct gsf__tile_gradient { // derivatives of the loss, per pixel
    GSF__LINES float r[GSF__TILE_PIXELS];
    float g[GSF__TILE_PIXELS], b[GSF__TILE_PIXELS];
    float z[GSF__TILE_PIXELS], a[GSF__TILE_PIXELS]; // with respect to sum(w z) and sum(w)
    float behind[GSF__TILE_PIXELS];                 // B of gsf__reverse_scalar
} gsf__tile_gradient;

enum { GSF__WITH_DEPTH = 1, GSF__STRAIGHT_THROUGH = 2, GSF__WITH_ABS = 4 };

typedef struct gsf__raster_kernels {
    // Blends the tile's list into `state`.
    void (*blend)(const gsf__tile* tile, gsf__tile_state* state, int flags);
    // Repeats the blending of T for list entries from `first` to `last` and keeps the steps. Stops after the entry
    // that brings the kept steps above GSF__BUCKET pixels / 8, or the last of those that are processed together with it.
    // Returns the entry to continue with, or tile->count when done. step_count: of gsf__step or gsf__wide_step
    size_t (*keep)(const gsf__tile* tile, float* T, size_t first, size_t last, gsf__step* steps, gsf__step_head* heads,
                   size_t* step_count);
    // Goes back to front over kept steps and writes the sums of the gradient moments of each entry to its slot (12
    // floats).
    void (*reverse)(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads, size_t step_count,
                    gsf__tile_gradient* gradient, float* slots, uint8_t* slot_used, int flags);
} gsf__raster_kernels;

// 2^x for x in [-126, 1], relative error below 2e-7 (minimax polynomial of degree 5 on [-1/2, 1/2]).
static float gsf__exp2_fast(float x) {
    const float above = x + 0.5f;
    int32_t k = (int32_t)above;
    k -= (float)k > above; // rounds down, without floorf, which takes longer before SSE 4.1
    const float f = x - (float)k;
    float p = 1.3276404e-3f;
    p = p * f + 9.6755413e-3f;
    p = p * f + 5.5507135e-2f;
    p = p * f + 0.24022120f;
    p = p * f + 0.69314694f;
    p = p * f + 1.0000001f;
    const int32_t bits = (k + 127) << 23;
    float scale;
    memcpy(&scale, &bits, sizeof scale);
    return p * scale;
}

// Finds, per row of the tile, the column of the ellipse's centre and the exponent there. Returns a bit per step that
// the ellipse overlaps.
static uint32_t gsf__rows_scalar(const gsf__record* rec, const gsf__tile* tile, float center[GSF__TILE],
                                 float exponent[GSF__TILE]) {
    const float u = rec->u - tile->x0 + rec->u_low, v = rec->v - tile->y0 + rec->v_low;
    uint32_t mask = 0;
    for (int row = 0; row < GSF__TILE; row++) {
        const float dy = (float)row - v;
        const float half2 = rec->h0 - rec->h1 * dy * dy;
        center[row] = u + rec->kx * dy;
        exponent[row] = rec->yy * dy * dy + rec->log2_opacity;
        if (!(half2 >= 0.0f)) continue;
        const float half = sqrtf(half2) + 0.02f;
        const float left = center[row] - half, right = center[row] + half;
        if (!(left <= (float)(GSF__TILE - 1) && right >= 0.0f)) continue;
        const int first = (left > 3.0f) + (left > 7.0f) + (left > 11.0f); // strips first..last; none if first > last
        const int last = (right >= 4.0f) + (right >= 8.0f) + (right >= 12.0f);
        mask |= (0x01010101u << 8 * first & 0x01010101u >> (24 - 8 * last)) << row / 2;
    }
    return mask;
}

// Row and column, in the tile, of a pixel of a step.
static int gsf__step_row(int s, int lane) { return 2 * (s & 7) + lane % 2; }
static int gsf__step_column(int s, int lane) { return GSF__STRIP * (s >> 3) + lane / 2; }

static uint32_t gsf__live_steps(const float* T) {
    uint32_t live = 0;
    for (uint32_t s = 0; s < GSF__STEPS; s++)
        for (int lane = 0; lane < 8; lane++)
            if (T[8 * s + (uint32_t)lane] > 0.0f) live |= 1u << s;
    return live;
}

// Blends a splat into the T of one pixel. Returns its alpha before the clamp, or 0 if it is not blended.
static float gsf__blend_pixel(const gsf__record* rec, float column, float center, float exponent, float* T) {
    const float e = column - center;
    const float x = rec->ee * e * e + exponent;
    if (!(x >= GSF__LOG2_ALPHA_MIN) || !(*T > 0.0f)) return 0.0f;
    const float raw = gsf__exp2_fast(x);
    const float alpha = raw < GSF__ALPHA_MAX ? raw : GSF__ALPHA_MAX;
    const float next = *T * (1.0f - alpha);
    if (next < GSF__T_MIN) {
        *T = -*T;
        return 0.0f;
    }
    *T = next;
    return raw;
}

static void gsf__blend_scalar(const gsf__tile* tile, gsf__tile_state* state, int flags) {
    uint32_t live = gsf__live_steps(state->T);
    float center[GSF__TILE], exponent[GSF__TILE];
    for (size_t i = 0; i < tile->count && live; i++) {
        const gsf__record* rec = tile->records + tile->splats[i];
        for (uint32_t m = gsf__rows_scalar(rec, tile, center, exponent) & live; m; m &= m - 1) {
            const int s = gsf__lowest_bit(m), row = gsf__step_row(s, 0);
            int open = 0;
            for (int lane = 0; lane < 8; lane++) {
                const int k = 8 * s + lane;
                const float T = state->T[k], column = (float)gsf__step_column(s, lane);
                const float raw = gsf__blend_pixel(rec, column, center[row + lane % 2], exponent[row + lane % 2], &state->T[k]);
                const float w = (raw < GSF__ALPHA_MAX ? raw : GSF__ALPHA_MAX) * T;
                if (raw > 0.0f) {
                    state->r[k] += w * rec->r;
                    state->g[k] += w * rec->g;
                    state->b[k] += w * rec->b;
                    if (flags & GSF__WITH_DEPTH) state->z[k] += w * rec->depth;
                }
                open |= state->T[k] > 0.0f;
            }
            if (!open) live &= ~(1u << s);
        }
    }
}

#if GSF__X86 || GSF__SIMD128

// Columns of the pixels of strip k, from 16 k on, and rows of those of a pair of rows j, from 8 j on: for one or two steps.
GSF__LINES static const float gsf__columns_of[64] = {0,  0,  1,  1,  2,  2,  3,  3,  0,  0,  1,  1,  2,  2,  3,  3,
                                                     4,  4,  5,  5,  6,  6,  7,  7,  4,  4,  5,  5,  6,  6,  7,  7,
                                                     8,  8,  9,  9,  10, 10, 11, 11, 8,  8,  9,  9,  10, 10, 11, 11,
                                                     12, 12, 13, 13, 14, 14, 15, 15, 12, 12, 13, 13, 14, 14, 15, 15};
GSF__LINES static const float gsf__rows_of[64] = {0,  1,  0,  1,  0,  1,  0,  1,  2,  3,  2,  3,  2,  3,  2,  3,
                                                  4,  5,  4,  5,  4,  5,  4,  5,  6,  7,  6,  7,  6,  7,  6,  7,
                                                  8,  9,  8,  9,  8,  9,  8,  9,  10, 11, 10, 11, 10, 11, 10, 11,
                                                  12, 13, 12, 13, 12, 13, 12, 13, 14, 15, 14, 15, 14, 15, 14, 15};

#endif

#if GSF__X86

// List entries whose rows are found together, before any of them is blended.
typedef struct gsf__entries {
    GSF__LINES float center[GSF__TOGETHER][GSF__TILE]; // as in gsf__rows_scalar
    float exponent[GSF__TOGETHER][GSF__TILE];
    uint32_t overlaps[GSF__TOGETHER]; // a bit per step or block; none beyond the entries
    const gsf__record* rec[GSF__TOGETHER];
} gsf__entries;

GSF__INLINE_AVX2 const gsf__record* gsf__entry(const gsf__tile* tile, size_t i) {
    enum { FETCHED = 16 };
    if (i + FETCHED < tile->count) _mm_prefetch((const char*)(tile->records + tile->splats[i + FETCHED]), _MM_HINT_T0);
    return tile->records + tile->splats[i];
}

// Bits of the pairs of rows whose interval from..to overlaps the strip that begins at column `first`.
GSF__INLINE_AVX2 uint32_t gsf__strip_avx2(__m256 from, __m256 to, float first) {
    const __m256 last = _mm256_set1_ps(first + (float)(GSF__STRIP - 1));
    const __m256 met = _mm256_and_ps(_mm256_cmp_ps(from, last, _CMP_LE_OQ),
                                     _mm256_cmp_ps(to, _mm256_set1_ps(first), _CMP_GE_OQ));
    return (uint32_t)_mm256_movemask_ps(met);
}

// Like gsf__rows_scalar, 8 rows at a time.
GSF__INLINE_AVX2 uint32_t gsf__rows_avx2(const gsf__tile* tile, const gsf__record* rec, float center[GSF__TILE],
                                         float exponent[GSF__TILE]) {
    const float u = rec->u - tile->x0 + rec->u_low, v = rec->v - tile->y0 + rec->v_low;
    const __m256 kx = _mm256_set1_ps(rec->kx), yy = _mm256_set1_ps(rec->yy), lo = _mm256_set1_ps(rec->log2_opacity);
    const __m256 h0 = _mm256_set1_ps(rec->h0), h1 = _mm256_set1_ps(rec->h1), zero = _mm256_setzero_ps();
    __m256 left[2], right[2];
    for (int k = 0; k < 2; k++) {
        const __m256 row = _mm256_add_ps(_mm256_setr_ps(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_ps(8.0f * (float)k));
        const __m256 dy = _mm256_sub_ps(row, _mm256_set1_ps(v));
        const __m256 half2 = _mm256_fnmadd_ps(_mm256_mul_ps(h1, dy), dy, h0);
        const __m256 c = _mm256_fmadd_ps(kx, dy, _mm256_set1_ps(u));
        _mm256_storeu_ps(center + 8 * k, c);
        _mm256_storeu_ps(exponent + 8 * k, _mm256_fmadd_ps(_mm256_mul_ps(yy, dy), dy, lo));
        const __m256 wide = _mm256_add_ps(_mm256_sqrt_ps(_mm256_max_ps(half2, zero)), _mm256_set1_ps(0.02f));
        const __m256 half = _mm256_blendv_ps(_mm256_set1_ps(-1e30f), wide, _mm256_cmp_ps(half2, zero, _CMP_GE_OQ));
        left[k] = _mm256_sub_ps(c, half);
        right[k] = _mm256_add_ps(c, half);
    }
    // of two rows, the union, which has no gap because the ellipse is convex; pairs of rows 0 1 4 5 2 3 6 7
    __m256 from = _mm256_min_ps(_mm256_shuffle_ps(left[0], left[1], 0x88), _mm256_shuffle_ps(left[0], left[1], 0xdd));
    __m256 to = _mm256_max_ps(_mm256_shuffle_ps(right[0], right[1], 0x88), _mm256_shuffle_ps(right[0], right[1], 0xdd));
    from = _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(from), 0xd8));
    to = _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(to), 0xd8));
    return gsf__strip_avx2(from, to, 0.0f) | gsf__strip_avx2(from, to, 4.0f) << 8 |
           gsf__strip_avx2(from, to, 8.0f) << 16 | gsf__strip_avx2(from, to, 12.0f) << 24;
}

// The list entries from `first` to `end`.
GSF__INLINE_AVX2 void gsf__find_avx2(const gsf__tile* tile, size_t first, size_t end, gsf__entries* entries) {
    size_t at = 0;
    for (size_t i = first; i < end; i++, at++) {
        entries->rec[at] = gsf__entry(tile, i);
        entries->overlaps[at] = gsf__rows_avx2(tile, entries->rec[at], entries->center[at], entries->exponent[at]);
    }
    while (at < GSF__TOGETHER) entries->overlaps[at++] = 0;
}

// 2^x where that is at least 1/255, else 0.
GSF__INLINE_AVX2 __m256 gsf__exp2_avx2(__m256 x) {
    const __m256 seen = _mm256_cmp_ps(x, _mm256_set1_ps(GSF__LOG2_ALPHA_MIN), _CMP_GE_OQ);
    const __m256 rounder = _mm256_set1_ps(12582912.0f); // leaves the nearest integer, ties to even, in the low bits
    const __m256 rounded = _mm256_add_ps(x, rounder), f = _mm256_sub_ps(x, _mm256_sub_ps(rounded, rounder));
    __m256 p = _mm256_set1_ps(1.3276404e-3f);
    p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(9.6755413e-3f));
    p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(5.5507135e-2f));
    p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(0.24022120f));
    p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(0.69314694f));
    p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(1.0000001f));
    const __m256i shift = _mm256_slli_epi32(_mm256_castps_si256(rounded), 23);
    return _mm256_and_ps(seen, _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), shift)));
}

// Alphas of an entry before the clamp, in the step of these columns and of two rows from `row` on.
GSF__INLINE_AVX2 __m256 gsf__alpha_avx2(const gsf__entries* entries, size_t at, __m256 columns, size_t row) {
    const double* centers = (const double*)(const void*)(entries->center[at] + row);
    const double* exponents = (const double*)(const void*)(entries->exponent[at] + row);
    const __m256 e = _mm256_sub_ps(columns, _mm256_castpd_ps(_mm256_broadcast_sd(centers)));
    const __m256 ee = _mm256_mul_ps(_mm256_set1_ps(entries->rec[at]->ee), e);
    return gsf__exp2_avx2(_mm256_fmadd_ps(ee, e, _mm256_castpd_ps(_mm256_broadcast_sd(exponents))));
}

GSF__INLINE_AVX2 uint32_t gsf__live_avx2(const float* T) {
    uint32_t live = 0;
    for (uint32_t s = 0; s < GSF__STEPS; s += 4) { // packs the signs of four steps; each half has four pixels of a step
        __m256i v[4];
        for (uint32_t k = 0; k < 4; k++) v[k] = _mm256_castps_si256(_mm256_loadu_ps(T + 8 * (s + k)));
        const __m256i signs = _mm256_packs_epi16(_mm256_packs_epi32(v[0], v[1]), _mm256_packs_epi32(v[2], v[3]));
        const __m128i sign = _mm_set1_epi8(-128);
        const __m128i both = _mm_and_si128(_mm256_castsi256_si128(signs), _mm256_extracti128_si256(signs, 1));
        const __m128i closed = _mm_cmpeq_epi32(_mm_and_si128(both, sign), sign);
        live |= (uint32_t)(_mm_movemask_ps(_mm_castsi128_ps(closed)) ^ 15) << s;
    }
    return live;
}

// The entries that overlap step s.
GSF__INLINE_AVX2 uint32_t gsf__entries_of_avx2(const gsf__entries* entries, uint32_t s) {
    uint32_t found = 0;
    for (int k = 0; k < GSF__TOGETHER; k += 8) { // the bit becomes the sign
        const __m256i overlaps = _mm256_loadu_si256((const __m256i*)(const void*)(entries->overlaps + k));
        const __m256i signs = _mm256_sll_epi32(overlaps, _mm_cvtsi32_si128((int)(GSF__STEPS - 1 - s)));
        found |= (uint32_t)_mm256_movemask_ps(_mm256_castsi256_ps(signs)) << k;
    }
    return found;
}

// Blends the entries `left` into step s while its pixels are in registers. Few steps have a pixel that is finished or
// becomes so; they need `closing`. Without it, such a step is left as it is and the result is 0. With it, the result is
// whether a pixel is still open, and T goes on falling where one is finished, so that no blend waits for a comparison.
GSF__INLINE_AVX2 int gsf__blend_step_avx2(const gsf__entries* entries, uint32_t left, uint32_t s, gsf__tile_state* state,
                                          int with_depth, int closing) {
    float *r = state->r + 8 * s, *g = state->g + 8 * s, *b = state->b + 8 * s, *z = state->z + 8 * s;
    const __m256 columns = _mm256_load_ps(gsf__columns_of + 16 * (s >> 3)), least = _mm256_set1_ps(GSF__T_MIN);
    __m256 last = _mm256_loadu_ps(state->T + 8 * s), T = _mm256_max_ps(last, _mm256_setzero_ps()), shown = last;
    __m256 red = _mm256_loadu_ps(r), green = _mm256_loadu_ps(g), blue = _mm256_loadu_ps(b), depth = _mm256_loadu_ps(z);
    for (; left; left &= left - 1) {
        const size_t at = (size_t)gsf__lowest_bit(left);
        const gsf__record* rec = entries->rec[at];
        const __m256 raw = gsf__alpha_avx2(entries, at, columns, 2 * (s & 7));
        const __m256 alpha = _mm256_min_ps(raw, _mm256_set1_ps(GSF__ALPHA_MAX)), next = _mm256_fnmadd_ps(T, alpha, T);
        __m256 w = _mm256_mul_ps(T, alpha);
        if (closing) {
            shown = _mm256_cmp_ps(next, least, _CMP_GE_OQ);
            w = _mm256_and_ps(shown, w);
            last = _mm256_blendv_ps(last, next, shown);
        }
        red = _mm256_fmadd_ps(w, _mm256_set1_ps(rec->r), red);
        green = _mm256_fmadd_ps(w, _mm256_set1_ps(rec->g), green);
        blue = _mm256_fmadd_ps(w, _mm256_set1_ps(rec->b), blue);
        if (with_depth) depth = _mm256_fmadd_ps(w, _mm256_set1_ps(rec->depth), depth);
        T = next;
    }
    if (closing) T = _mm256_or_ps(last, _mm256_andnot_ps(shown, _mm256_set1_ps(-0.0f)));
    else if (_mm256_movemask_ps(_mm256_cmp_ps(T, least, _CMP_GE_OQ)) != 255) return 0;
    _mm256_storeu_ps(state->T + 8 * s, T);
    _mm256_storeu_ps(r, red);
    _mm256_storeu_ps(g, green);
    _mm256_storeu_ps(b, blue);
    if (with_depth) _mm256_storeu_ps(z, depth);
    return !closing || _mm256_movemask_ps(shown) != 0;
}

// Entries are found together; then each step blends those that overlap it.
GSF__INLINE_AVX2 void gsf__blend_avx2_body(const gsf__tile* tile, gsf__tile_state* state, int with_depth) {
    gsf__entries entries;
    uint32_t live = gsf__live_avx2(state->T);
    for (size_t i = 0, end; i < tile->count && live; i = end) {
        end = i + GSF__TOGETHER < tile->count ? i + GSF__TOGETHER : tile->count;
        gsf__find_avx2(tile, i, end, &entries);
        for (uint32_t m = live; m; m &= m - 1) {
            const uint32_t s = (uint32_t)gsf__lowest_bit(m), found = gsf__entries_of_avx2(&entries, s);
            if (!found || gsf__blend_step_avx2(&entries, found, s, state, with_depth, 0)) continue;
            if (!gsf__blend_step_avx2(&entries, found, s, state, with_depth, 1)) live &= ~(1u << s);
        }
    }
}

GSF__TARGET_AVX2 static void gsf__blend_avx2(const gsf__tile* tile, gsf__tile_state* state, int flags) {
    if (flags & GSF__WITH_DEPTH) gsf__blend_avx2_body(tile, state, 1);
    else gsf__blend_avx2_body(tile, state, 0);
}

enum { GSF__BLOCKS = GSF__TILE_PIXELS / 16 }; // block b: 4 x 4 pixels from index 16 b on, strip b >> 2

// As gsf__rows_avx2. A bit per block that the ellipse overlaps, in the order of the rows: bit 4 * (row / 4) + strip.
GSF__INLINE_AVX512 uint32_t gsf__rows_avx512(const gsf__tile* tile, const gsf__record* rec, float center[GSF__TILE],
                                             float exponent[GSF__TILE]) {
    const float u = rec->u - tile->x0 + rec->u_low, v = rec->v - tile->y0 + rec->v_low;
    const __m512 row = _mm512_setr_ps(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15), zero = _mm512_setzero_ps();
    const __m512 first = _mm512_setr_ps(0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12);
    const __m512 dy = _mm512_sub_ps(row, _mm512_set1_ps(v));
    const __m512 half2 = _mm512_fnmadd_ps(_mm512_mul_ps(_mm512_set1_ps(rec->h1), dy), dy, _mm512_set1_ps(rec->h0));
    const __m512 c = _mm512_fmadd_ps(_mm512_set1_ps(rec->kx), dy, _mm512_set1_ps(u));
    const __m512 yy = _mm512_mul_ps(_mm512_set1_ps(rec->yy), dy);
    _mm512_storeu_ps(center, c);
    _mm512_storeu_ps(exponent, _mm512_fmadd_ps(yy, dy, _mm512_set1_ps(rec->log2_opacity)));
    const __m512 wide = _mm512_add_ps(_mm512_sqrt_ps(_mm512_max_ps(half2, zero)), _mm512_set1_ps(0.02f));
    const __m512 half = _mm512_mask_blend_ps(_mm512_cmp_ps_mask(half2, zero, _CMP_GE_OQ), _mm512_set1_ps(-1e30f), wide);
    __m512 from = _mm512_sub_ps(c, half), to = _mm512_add_ps(c, half); // then the union over the rows of a block
    from = _mm512_min_ps(from, _mm512_shuffle_ps(from, from, 0xb1));
    to = _mm512_max_ps(to, _mm512_shuffle_ps(to, to, 0xb1));
    from = _mm512_min_ps(from, _mm512_shuffle_ps(from, from, 0x4e));
    to = _mm512_max_ps(to, _mm512_shuffle_ps(to, to, 0x4e));
    const __mmask16 starts = _mm512_cmp_ps_mask(from, _mm512_add_ps(first, _mm512_set1_ps(3.0f)), _CMP_LE_OQ);
    return _mm512_mask_cmp_ps_mask(starts, to, first, _CMP_GE_OQ);
}

GSF__INLINE_AVX512 void gsf__find_avx512(const gsf__tile* tile, size_t first, size_t end, gsf__entries* entries) {
    size_t at = 0;
    for (size_t i = first; i < end; i++, at++) {
        entries->rec[at] = gsf__entry(tile, i);
        entries->overlaps[at] = gsf__rows_avx512(tile, entries->rec[at], entries->center[at], entries->exponent[at]);
    }
    while (at < GSF__TOGETHER) entries->overlaps[at++] = 0;
}

// As gsf__alpha_avx2, in a block of these columns and of four rows from `row` on.
GSF__INLINE_AVX512 __m512 gsf__alpha_avx512(const gsf__entries* entries, size_t at, __m512 columns, size_t row) {
    const __m512i spread = _mm512_setr_epi32(0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3);
    const __m512 center = _mm512_permutevar_ps(_mm512_broadcast_f32x4(_mm_loadu_ps(entries->center[at] + row)), spread);
    const __m512 exponent = _mm512_permutevar_ps(_mm512_broadcast_f32x4(_mm_loadu_ps(entries->exponent[at] + row)), spread);
    const __m512 e = _mm512_sub_ps(columns, center);
    const __m512 x = _mm512_fmadd_ps(_mm512_mul_ps(_mm512_set1_ps(entries->rec[at]->ee), e), e, exponent);
    const __mmask16 seen = _mm512_cmp_ps_mask(x, _mm512_set1_ps(GSF__LOG2_ALPHA_MIN), _CMP_GE_OQ);
    const __m512 k = gsf__v_round_avx512(x), f = _mm512_sub_ps(x, k);
    __m512 p = _mm512_set1_ps(1.3276404e-3f); // as in gsf__exp2_avx2
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(9.6755413e-3f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(5.5507135e-2f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(0.24022120f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(0.69314694f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(1.0000001f));
    return gsf__v_keep_avx512(seen, gsf__v_scale2_avx512(p, k));
}

GSF__INLINE_AVX512 uint32_t gsf__live_avx512(const float* T) { // bits as in gsf__rows_avx512
    uint32_t live = 0;
    for (uint32_t b = 0; b < GSF__BLOCKS; b++) {
        const __mmask16 open = _mm512_cmp_ps_mask(_mm512_loadu_ps(T + 16 * b), _mm512_setzero_ps(), _CMP_GT_OQ);
        live |= (uint32_t)(open != 0) << (4 * (b & 3) + (b >> 2));
    }
    return live;
}

// The entries that overlap the block with this number, which is its bit.
GSF__INLINE_AVX512 uint32_t gsf__entries_of_avx512(const gsf__entries* entries, uint32_t number) {
    const __m512i bit = _mm512_set1_epi32((int)(1u << number));
    return (uint32_t)_mm512_test_epi32_mask(_mm512_loadu_si512(entries->overlaps), bit) |
           (uint32_t)_mm512_test_epi32_mask(_mm512_loadu_si512(entries->overlaps + 16), bit) << 16;
}

// As gsf__blend_step_avx2, with a block in place of a step.
GSF__INLINE_AVX512 int gsf__blend_block_avx512(const gsf__entries* entries, uint32_t left, uint32_t block,
                                               gsf__tile_state* state, int with_depth, int closing) {
    float *r = state->r + 16 * block, *g = state->g + 16 * block, *b = state->b + 16 * block, *z = state->z + 16 * block;
    const __m512 columns = _mm512_load_ps(gsf__columns_of + 16 * (block >> 2)), least = _mm512_set1_ps(GSF__T_MIN);
    __m512 last = _mm512_loadu_ps(state->T + 16 * block), T = _mm512_max_ps(last, _mm512_setzero_ps());
    __m512 red = _mm512_loadu_ps(r), green = _mm512_loadu_ps(g), blue = _mm512_loadu_ps(b), depth = _mm512_loadu_ps(z);
    __mmask16 shown = 0;
    for (; left; left &= left - 1) {
        const size_t at = (size_t)gsf__lowest_bit(left);
        const gsf__record* rec = entries->rec[at];
        const __m512 raw = gsf__alpha_avx512(entries, at, columns, 4 * (block & 3));
        const __m512 alpha = _mm512_min_ps(raw, _mm512_set1_ps(GSF__ALPHA_MAX)), next = _mm512_fnmadd_ps(T, alpha, T);
        __m512 w = _mm512_mul_ps(T, alpha);
        if (closing) {
            shown = _mm512_cmp_ps_mask(next, least, _CMP_GE_OQ);
            w = _mm512_maskz_mov_ps(shown, w);
            last = _mm512_mask_mov_ps(last, shown, next);
        }
        red = _mm512_fmadd_ps(w, _mm512_set1_ps(rec->r), red);
        green = _mm512_fmadd_ps(w, _mm512_set1_ps(rec->g), green);
        blue = _mm512_fmadd_ps(w, _mm512_set1_ps(rec->b), blue);
        if (with_depth) depth = _mm512_fmadd_ps(w, _mm512_set1_ps(rec->depth), depth);
        T = next;
    }
    if (closing) T = _mm512_mask_or_ps(last, (__mmask16)~shown, last, _mm512_set1_ps(-0.0f));
    else if (_mm512_cmp_ps_mask(T, least, _CMP_GE_OQ) != 0xffff) return 0;
    _mm512_storeu_ps(state->T + 16 * block, T);
    _mm512_storeu_ps(r, red);
    _mm512_storeu_ps(g, green);
    _mm512_storeu_ps(b, blue);
    if (with_depth) _mm512_storeu_ps(z, depth);
    return !closing || shown != 0;
}

// As gsf__blend_avx2_body.
GSF__INLINE_AVX512 void gsf__blend_avx512_body(const gsf__tile* tile, gsf__tile_state* state, int with_depth) {
    gsf__entries entries;
    uint32_t live = gsf__live_avx512(state->T);
    for (size_t i = 0, end; i < tile->count && live; i = end) {
        end = i + GSF__TOGETHER < tile->count ? i + GSF__TOGETHER : tile->count;
        gsf__find_avx512(tile, i, end, &entries);
        for (uint32_t m = live; m; m &= m - 1) {
            const uint32_t number = (uint32_t)gsf__lowest_bit(m), block = (number & 3) << 2 | number >> 2;
            const uint32_t found = gsf__entries_of_avx512(&entries, number);
            if (!found || gsf__blend_block_avx512(&entries, found, block, state, with_depth, 0)) continue;
            if (!gsf__blend_block_avx512(&entries, found, block, state, with_depth, 1)) live &= ~(1u << number);
        }
    }
}

GSF__TARGET_AVX512 static void gsf__blend_avx512(const gsf__tile* tile, gsf__tile_state* state, int flags) {
    if (flags & GSF__WITH_DEPTH) gsf__blend_avx512_body(tile, state, 1);
    else gsf__blend_avx512_body(tile, state, 0);
}

#endif // GSF__X86

#if GSF__SIMD128

// A step is two vectors: two columns each, in which the two rows alternate.
typedef struct gsf__pair_simd128 { gsf__vf_simd128 low, high; } gsf__pair_simd128;

#if GSF__NEON
GSF__INLINE_SIMD128 uint32_t gsf__bits8_simd128(gsf__vm_simd128 low, gsf__vm_simd128 high) { // a bit per lane of both
    const uint16x8_t bit = {1, 2, 4, 8, 16, 32, 64, 128};
    return vaddvq_u16(vandq_u16(vuzp1q_u16(vreinterpretq_u16_s32(low), vreinterpretq_u16_s32(high)), bit));
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__twice_simd128(const float* p) { // p[0] p[1] p[0] p[1]
    const float32x2_t pair = vld1_f32(p);
    return vcombine_f32(pair, pair);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__even_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return vuzp1q_f32(a, b); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__odd_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return vuzp2q_f32(a, b); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__least_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return vminq_f32(a, b); }
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__most_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { return vmaxq_f32(a, b); }
GSF__INLINE_SIMD128 int gsf__all_negative_simd128(gsf__vi_simd128 x) { return vmaxvq_s32(x) < 0; }
GSF__INLINE_SIMD128 int gsf__any_positive_simd128(gsf__vf_simd128 x) { return vmaxvq_f32(x) > 0.0f; }
#else
GSF__INLINE_SIMD128 uint32_t gsf__bits8_simd128(gsf__vm_simd128 low, gsf__vm_simd128 high) {
    return (uint32_t)wasm_i16x8_bitmask(wasm_i16x8_narrow_i32x4((v128_t)low, (v128_t)high));
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__twice_simd128(const float* p) {
    return (gsf__vf_simd128)wasm_v128_load64_splat(p);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__even_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return __builtin_shufflevector(a, b, 0, 2, 4, 6);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__odd_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return __builtin_shufflevector(a, b, 1, 3, 5, 7);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__least_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return gsf__v_min_simd128(a, b);
}
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__most_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) {
    return gsf__v_max_simd128(a, b);
}
GSF__INLINE_SIMD128 int gsf__all_negative_simd128(gsf__vi_simd128 x) { return wasm_i32x4_bitmask((v128_t)x) == 15; }
GSF__INLINE_SIMD128 int gsf__any_positive_simd128(gsf__vf_simd128 x) {
    return wasm_v128_any_true(wasm_f32x4_gt((v128_t)x, wasm_f32x4_const(0, 0, 0, 0)));
}
#endif

// Like gsf__rows_scalar, 4 rows at a time. Values are finite, so that least and most need not care for a NaN.
GSF__INLINE_SIMD128 uint32_t gsf__rows_simd128(const gsf__record* rec, float u, float v, float center[GSF__TILE],
                                               float exponent[GSF__TILE]) {
    const gsf__vf_simd128 kx = gsf__v_set_simd128(rec->kx), yy = gsf__v_set_simd128(rec->yy), zero = gsf__v_set_simd128(0.0f);
    const gsf__vf_simd128 h0 = gsf__v_set_simd128(rec->h0), h1 = gsf__v_set_simd128(rec->h1);
    const gsf__vf_simd128 lo = gsf__v_set_simd128(rec->log2_opacity), center_u = gsf__v_set_simd128(u);
    const gsf__vf_simd128 rows = {0, 1, 2, 3}, margin = gsf__v_set_simd128(0.02f), none = gsf__v_set_simd128(-1e30f);
    gsf__vf_simd128 left[GSF__TILE / 4], right[GSF__TILE / 4], from[2], to[2];
    for (int k = 0; k < GSF__TILE / 4; k++) {
        const gsf__vf_simd128 dy = rows + gsf__v_set_simd128((float)(4 * k) - v);
        const gsf__vf_simd128 half2 = gsf__v_nmadd_simd128(h1 * dy, dy, h0), c = gsf__v_madd_simd128(kx, dy, center_u);
        gsf__v_store_simd128(center + 4 * k, c);
        gsf__v_store_simd128(exponent + 4 * k, gsf__v_madd_simd128(yy * dy, dy, lo));
        const gsf__vf_simd128 wide = gsf__v_sqrt_simd128(gsf__most_simd128(half2, zero)) + margin;
        const gsf__vf_simd128 half = gsf__v_select_simd128(gsf__v_ge_simd128(half2, zero), wide, none);
        left[k] = c - half;
        right[k] = c + half;
    }
    for (int k = 0; k < 2; k++) { // of two rows, the union, which has no gap because the ellipse is convex
        from[k] = gsf__least_simd128(gsf__even_simd128(left[2 * k], left[2 * k + 1]),
                                     gsf__odd_simd128(left[2 * k], left[2 * k + 1]));
        to[k] = gsf__most_simd128(gsf__even_simd128(right[2 * k], right[2 * k + 1]),
                                  gsf__odd_simd128(right[2 * k], right[2 * k + 1]));
    }
    uint32_t mask = 0;
    for (int strip = 0; strip < GSF__TILE / GSF__STRIP; strip++) {
        const gsf__vf_simd128 first = gsf__v_set_simd128((float)(GSF__STRIP * strip));
        const gsf__vf_simd128 last = gsf__v_set_simd128((float)(GSF__STRIP * strip + GSF__STRIP - 1));
        mask |= gsf__bits8_simd128(gsf__v_le_simd128(from[0], last) & gsf__v_ge_simd128(to[0], first),
                                   gsf__v_le_simd128(from[1], last) & gsf__v_ge_simd128(to[1], first)) << (8 * strip);
    }
    return mask;
}

GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__exp2_simd128(gsf__vf_simd128 x) { // as gsf__exp2_avx2
    const gsf__vf_simd128 k = gsf__v_round_simd128(x), f = x - k;
    gsf__vf_simd128 p = gsf__v_set_simd128(1.3276404e-3f);
    p = gsf__v_madd_simd128(p, f, gsf__v_set_simd128(9.6755413e-3f));
    p = gsf__v_madd_simd128(p, f, gsf__v_set_simd128(5.5507135e-2f));
    p = gsf__v_madd_simd128(p, f, gsf__v_set_simd128(0.24022120f));
    p = gsf__v_madd_simd128(p, f, gsf__v_set_simd128(0.69314694f));
    p = gsf__v_madd_simd128(p, f, gsf__v_set_simd128(1.0000001f));
    const gsf__vi_simd128 shift = gsf__vi_shl_simd128(gsf__v_to_int_simd128(k), 23);
    return gsf__vi_as_floats_simd128(gsf__vi_add_simd128(gsf__v_bits_simd128(p), shift));
}

// Alphas, before the clamp, of a step whose rows have their centre and exponent in `center` and `exponent`; 0 below 1/255.
GSF__INLINE_SIMD128 gsf__pair_simd128 gsf__alphas_simd128(float ee, const float* center, const float* exponent, uint32_t s) {
    const gsf__vf_simd128 c = gsf__twice_simd128(center), x0 = gsf__twice_simd128(exponent);
    const gsf__vf_simd128 limit = gsf__v_set_simd128(GSF__LOG2_ALPHA_MIN), scale = gsf__v_set_simd128(ee);
    const gsf__vf_simd128 e0 = gsf__v_load_simd128(gsf__columns_of + 16 * (s >> 3)) - c;
    const gsf__vf_simd128 e1 = gsf__v_load_simd128(gsf__columns_of + 16 * (s >> 3) + 4) - c;
    const gsf__vf_simd128 low = gsf__v_madd_simd128(scale * e0, e0, x0), high = gsf__v_madd_simd128(scale * e1, e1, x0);
    const gsf__pair_simd128 raw = {gsf__v_keep_simd128(gsf__v_ge_simd128(low, limit), gsf__exp2_simd128(low)),
                                   gsf__v_keep_simd128(gsf__v_ge_simd128(high, limit), gsf__exp2_simd128(high))};
    return raw;
}

// As gsf__next_avx2.
GSF__INLINE_SIMD128 gsf__vf_simd128 gsf__next_simd128(gsf__vf_simd128 T, gsf__vf_simd128 raw, gsf__vf_simd128* weight,
                                                      gsf__vm_simd128* shown) {
    const gsf__vf_simd128 alpha = gsf__least_simd128(raw, gsf__v_set_simd128(GSF__ALPHA_MAX));
    const gsf__vf_simd128 open = gsf__most_simd128(T, gsf__v_set_simd128(0.0f)), next = gsf__v_nmadd_simd128(open, alpha, T);
    *shown = gsf__v_ge_simd128(next, gsf__v_set_simd128(GSF__T_MIN));
    *weight = gsf__v_keep_simd128(*shown, open * alpha);
    const gsf__vf_simd128 finished = (gsf__vf_simd128)((gsf__vi_simd128)T | gsf__vi_set_simd128(-0x7fffffff - 1));
    return gsf__v_select_simd128(*shown, next, finished);
}

GSF__INLINE_SIMD128 int gsf__is_open_simd128(gsf__vf_simd128 a, gsf__vf_simd128 b) { // any of the pixels
    return !gsf__all_negative_simd128((gsf__vi_simd128)a & (gsf__vi_simd128)b);
}

GSF__INLINE_SIMD128 uint32_t gsf__live_simd128(const float* T) {
    uint32_t live = 0;
    for (uint32_t s = 0; s < GSF__STEPS; s++)
        live |= (uint32_t)gsf__is_open_simd128(gsf__v_load_simd128(T + 8 * s), gsf__v_load_simd128(T + 8 * s + 4)) << s;
    return live;
}

GSF__INLINE_SIMD128 void gsf__add_simd128(float* sum, gsf__vf_simd128 w0, gsf__vf_simd128 w1, float factor) {
    const gsf__vf_simd128 f = gsf__v_set_simd128(factor);
    gsf__v_store_simd128(sum, gsf__v_madd_simd128(w0, f, gsf__v_load_simd128(sum)));
    gsf__v_store_simd128(sum + 4, gsf__v_madd_simd128(w1, f, gsf__v_load_simd128(sum + 4)));
}

static void gsf__blend_simd128(const gsf__tile* tile, gsf__tile_state* state, int flags) {
    uint32_t live = gsf__live_simd128(state->T);
    float center[GSF__TILE], exponent[GSF__TILE];
    for (size_t i = 0; i < tile->count && live; i++) {
        const gsf__record* rec = tile->records + tile->splats[i];
        const float u = rec->u - tile->x0 + rec->u_low, v = rec->v - tile->y0 + rec->v_low;
        for (uint32_t m = gsf__rows_simd128(rec, u, v, center, exponent) & live; m; m &= m - 1) {
            const uint32_t s = (uint32_t)gsf__lowest_bit(m), row = 2 * (s & 7);
            const size_t at = 8 * s;
            const gsf__pair_simd128 raw = gsf__alphas_simd128(rec->ee, center + row, exponent + row, s);
            gsf__vf_simd128 w0, w1;
            gsf__vm_simd128 shown;
            const gsf__vf_simd128 T0 = gsf__next_simd128(gsf__v_load_simd128(state->T + at), raw.low, &w0, &shown);
            const gsf__vf_simd128 T1 = gsf__next_simd128(gsf__v_load_simd128(state->T + at + 4), raw.high, &w1, &shown);
            gsf__v_store_simd128(state->T + at, T0);
            gsf__v_store_simd128(state->T + at + 4, T1);
            gsf__add_simd128(state->r + at, w0, w1, rec->r);
            gsf__add_simd128(state->g + at, w0, w1, rec->g);
            gsf__add_simd128(state->b + at, w0, w1, rec->b);
            if (flags & GSF__WITH_DEPTH) gsf__add_simd128(state->z + at, w0, w1, rec->depth);
            if (!gsf__is_open_simd128(T0, T1)) live &= ~(1u << s);
        }
    }
}

#endif // GSF__SIMD128

// ---- >>raster backward ---------------------------------------------------------

static size_t gsf__keep_scalar(const gsf__tile* tile, float* T, size_t first, size_t last, gsf__step* steps,
                               gsf__step_head* heads, size_t* step_count) {
    uint32_t live = gsf__live_steps(T);
    float center[GSF__TILE], exponent[GSF__TILE];
    size_t kept = 0, i = first;
    for (; i < last && live && kept <= GSF__BUCKET; i++) {
        const gsf__record* rec = tile->records + tile->splats[i];
        for (uint32_t m = gsf__rows_scalar(rec, tile, center, exponent) & live; m; m &= m - 1) {
            const int s = gsf__lowest_bit(m);
            int open = 0, any = 0;
            for (int lane = 0; lane < 8; lane++) {
                float* t = T + 8 * s + lane;
                const int row = gsf__step_row(s, lane);
                const float column = (float)gsf__step_column(s, lane);
                steps[kept].T[lane] = *t > 0.0f ? *t : 0.0f;
                const float raw = gsf__blend_pixel(rec, column, center[row], exponent[row], t);
                steps[kept].alpha[lane] = raw;
                any |= raw > 0.0f;
                open |= *t > 0.0f;
            }
            heads[kept].entry = (uint32_t)i;
            heads[kept].step = (uint32_t)s;
            kept += (size_t)any;
            if (!open) live &= ~(1u << s);
        }
    }
    *step_count = kept;
    return live && i < last ? i : tile->count;
}

/* Reverse pass. Let F be the splat's contribution per unit of weight, multiplied by the loss gradient
   (c.g + z gz + ga), and B the same for everything behind the splat (at first the background). The splat and everything
   behind it contribute T (alpha F + (1 - alpha) B), so
       dL/dalpha = T (F - B),   B <- B + alpha (F - B)
   without any division by 1 - alpha. */
static void gsf__reverse_scalar(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads,
                                size_t step_count, gsf__tile_gradient* gradient, float* slots,
                                uint8_t* slot_used, int flags) {
    for (size_t k = step_count; k > 0;) {
        const uint32_t entry = heads[k - 1].entry;
        const gsf__record* rec = tile->records + tile->splats[entry];
        const float u = rec->u - tile->x0 + rec->u_low, v = rec->v - tile->y0 + rec->v_low;
        const float conic_a = rec->ee * -1.3862944f, conic_q = rec->yy * -1.3862944f, conic_b = -rec->kx * conic_a;
        float sums[GSF__SLOT_FLOATS];
        memset(sums, 0, sizeof sums);
        for (; k > 0 && heads[k - 1].entry == entry; k--) {
            const gsf__step* step = steps + k - 1;
            const int s = (int)heads[k - 1].step;
            const float dys[2] = {(float)gsf__step_row(s, 0) - v, (float)gsf__step_row(s, 1) - v};
            const float centers[2] = {u + rec->kx * dys[0], u + rec->kx * dys[1]};
            for (int lane = 0; lane < 8; lane++) {
                const float raw = step->alpha[lane];
                if (!(raw > 0.0f)) continue;
                const int at = 8 * s + lane;
                const float dy = dys[lane % 2], e = (float)gsf__step_column(s, lane) - centers[lane % 2];
                const float alpha = raw < GSF__ALPHA_MAX ? raw : GSF__ALPHA_MAX, w = alpha * step->T[lane];
                float F = rec->r * gradient->r[at] + rec->g * gradient->g[at] + rec->b * gradient->b[at];
                if (flags & GSF__WITH_DEPTH) F += rec->depth * gradient->z[at] + gradient->a[at];
                const float difference = F - gradient->behind[at];
                gradient->behind[at] += alpha * difference;
                float p = step->T[lane] * difference * raw;
                if (raw > GSF__ALPHA_MAX && !(flags & GSF__STRAIGHT_THROUGH)) p = 0.0f;
                sums[GSF__SLOT_P] += p;
                sums[GSF__SLOT_E] += p * e;
                sums[GSF__SLOT_EE] += p * e * e;
                sums[GSF__SLOT_Y] += p * dy;
                sums[GSF__SLOT_EY] += p * e * dy;
                sums[GSF__SLOT_YY] += p * dy * dy;
                sums[GSF__SLOT_R] += w * gradient->r[at];
                sums[GSF__SLOT_G] += w * gradient->g[at];
                sums[GSF__SLOT_B] += w * gradient->b[at];
                if (flags & GSF__WITH_DEPTH) sums[GSF__SLOT_Z] += w * gradient->z[at];
                sums[GSF__SLOT_ABS_X] += fabsf(p * conic_a * e);
                sums[GSF__SLOT_ABS_Y] += fabsf(p * (conic_b * e + conic_q * dy));
            }
        }
        memcpy(slots + GSF__SLOT_FLOATS * entry, sums, sizeof sums); // complete: an entry's steps are all in one bucket
        slot_used[entry] = 1;
    }
}

#if GSF__X86

// Reserves places, in the order of the list, for the steps of found entries that are in `live`; returns the one behind them.
GSF__INLINE_AVX2 size_t gsf__reserve_steps(const gsf__entries* entries, uint32_t live, size_t kept,
                                           size_t place[GSF__TOGETHER]) {
    for (size_t at = 0; at < GSF__TOGETHER; at++) {
        place[at] = kept;
        kept += (size_t)__builtin_popcount(entries->overlaps[at] & live);
    }
    return kept;
}

// As gsf__blend_step_avx2, for T; keeps each entry's alphas and T at the place of its next step, and the entry's number, which
// counts from `first`.
GSF__INLINE_AVX2 int gsf__keep_step_avx2(const gsf__entries* entries, uint32_t found, uint32_t s, size_t first, float* T_tile,
                                         size_t place[GSF__TOGETHER], gsf__step* steps, gsf__step_head* heads,
                                         int closing) {
    const __m256 columns = _mm256_load_ps(gsf__columns_of + 16 * (s >> 3)), least = _mm256_set1_ps(GSF__T_MIN);
    __m256 last = _mm256_loadu_ps(T_tile + 8 * s), T = _mm256_max_ps(last, _mm256_setzero_ps()), shown = last;
    for (uint32_t left = found; left; left &= left - 1) {
        const size_t at = (size_t)gsf__lowest_bit(left), k = place[at]++;
        __m256 raw = gsf__alpha_avx2(entries, at, columns, 2 * (s & 7));
        const __m256 next = _mm256_fnmadd_ps(T, _mm256_min_ps(raw, _mm256_set1_ps(GSF__ALPHA_MAX)), T);
        if (closing) {
            shown = _mm256_cmp_ps(next, least, _CMP_GE_OQ);
            raw = _mm256_and_ps(shown, raw);
            last = _mm256_blendv_ps(last, next, shown);
        }
        _mm256_storeu_ps(steps[k].alpha, raw);
        _mm256_storeu_ps(steps[k].T, T);
        heads[k].entry = (uint32_t)(first + at);
        heads[k].step = s;
        T = next;
    }
    if (closing) T = _mm256_or_ps(last, _mm256_andnot_ps(shown, _mm256_set1_ps(-0.0f)));
    else if (_mm256_movemask_ps(_mm256_cmp_ps(T, least, _CMP_GE_OQ)) != 255) {
        for (uint32_t left = found; left; left &= left - 1) place[gsf__lowest_bit(left)]--;
        return 0;
    }
    _mm256_storeu_ps(T_tile + 8 * s, T);
    return !closing || _mm256_movemask_ps(shown) != 0;
}

// Goes through the tile as gsf__blend_avx2_body does, step by step, but writes in the order of the list, as reverse reads.
GSF__TARGET_AVX2 static size_t gsf__keep_avx2(const gsf__tile* tile, float* T, size_t first, size_t last, gsf__step* steps,
                                              gsf__step_head* heads, size_t* step_count) {
    gsf__entries entries;
    size_t place[GSF__TOGETHER], kept = 0, i = first;
    uint32_t live = gsf__live_avx2(T);
    for (size_t end; i < last && live && kept <= GSF__BUCKET; i = end) {
        end = i + GSF__TOGETHER < last ? i + GSF__TOGETHER : last;
        gsf__find_avx2(tile, i, end, &entries);
        kept = gsf__reserve_steps(&entries, live, kept, place);
        for (uint32_t m = live; m; m &= m - 1) {
            const uint32_t s = (uint32_t)gsf__lowest_bit(m), found = gsf__entries_of_avx2(&entries, s);
            if (found && !gsf__keep_step_avx2(&entries, found, s, i, T, place, steps, heads, 0) &&
                !gsf__keep_step_avx2(&entries, found, s, i, T, place, steps, heads, 1))
                live &= ~(1u << s);
        }
    }
    *step_count = kept;
    return live && i < last ? i : tile->count;
}

// As gsf__keep_step_avx2, with a block in place of a step.
GSF__INLINE_AVX512 int gsf__keep_block_avx512(const gsf__entries* entries, uint32_t found, uint32_t block, size_t first,
                                              float* T_tile, size_t place[GSF__TOGETHER], gsf__wide_step* steps,
                                              gsf__step_head* heads, int closing) {
    const __m512 columns = _mm512_load_ps(gsf__columns_of + 16 * (block >> 2)), least = _mm512_set1_ps(GSF__T_MIN);
    __m512 last = _mm512_loadu_ps(T_tile + 16 * block), T = _mm512_max_ps(last, _mm512_setzero_ps());
    __mmask16 shown = 0;
    for (uint32_t left = found; left; left &= left - 1) {
        const size_t at = (size_t)gsf__lowest_bit(left), k = place[at]++;
        __m512 raw = gsf__alpha_avx512(entries, at, columns, 4 * (block & 3));
        const __m512 next = _mm512_fnmadd_ps(T, _mm512_min_ps(raw, _mm512_set1_ps(GSF__ALPHA_MAX)), T);
        if (closing) {
            shown = _mm512_cmp_ps_mask(next, least, _CMP_GE_OQ);
            raw = _mm512_maskz_mov_ps(shown, raw);
            last = _mm512_mask_mov_ps(last, shown, next);
        }
        _mm512_storeu_ps(steps[k].alpha, raw);
        _mm512_storeu_ps(steps[k].T, T);
        heads[k].entry = (uint32_t)(first + at);
        heads[k].step = block;
        T = next;
    }
    if (closing) T = _mm512_mask_or_ps(last, (__mmask16)~shown, last, _mm512_set1_ps(-0.0f));
    else if (_mm512_cmp_ps_mask(T, least, _CMP_GE_OQ) != 0xffff) {
        for (uint32_t left = found; left; left &= left - 1) place[gsf__lowest_bit(left)]--;
        return 0;
    }
    _mm512_storeu_ps(T_tile + 16 * block, T);
    return !closing || shown != 0;
}

// As gsf__keep_avx2.
GSF__TARGET_AVX512 static size_t gsf__keep_avx512(const gsf__tile* tile, float* T, size_t first, size_t last,
                                                  gsf__step* memory, gsf__step_head* heads, size_t* step_count) {
    gsf__wide_step* steps = (gsf__wide_step*)(void*)memory;
    gsf__entries entries;
    size_t place[GSF__TOGETHER], kept = 0, i = first;
    uint32_t live = gsf__live_avx512(T);
    for (size_t end; i < last && live && kept <= GSF__BUCKET / 2; i = end) {
        end = i + GSF__TOGETHER < last ? i + GSF__TOGETHER : last;
        gsf__find_avx512(tile, i, end, &entries);
        kept = gsf__reserve_steps(&entries, live, kept, place);
        for (uint32_t m = live; m; m &= m - 1) {
            const uint32_t number = (uint32_t)gsf__lowest_bit(m), block = (number & 3) << 2 | number >> 2;
            const uint32_t found = gsf__entries_of_avx512(&entries, number);
            if (found && !gsf__keep_block_avx512(&entries, found, block, i, T, place, steps, heads, 0) &&
                !gsf__keep_block_avx512(&entries, found, block, i, T, place, steps, heads, 1))
                live &= ~(1u << number);
        }
    }
    *step_count = kept;
    return live && i < last ? i : tile->count;
}

// Horizontal sums of eight vectors, one per lane of the result.
GSF__TARGET_AVX2 static inline __m256 gsf__sum8_avx2(__m256 a, __m256 b, __m256 c, __m256 d, __m256 e, __m256 f, __m256 g,
                                                     __m256 h) {
    const __m256 abcd = _mm256_hadd_ps(_mm256_hadd_ps(a, b), _mm256_hadd_ps(c, d));
    const __m256 efgh = _mm256_hadd_ps(_mm256_hadd_ps(e, f), _mm256_hadd_ps(g, h));
    return _mm256_add_ps(_mm256_permute2f128_ps(abcd, efgh, 0x20), _mm256_permute2f128_ps(abcd, efgh, 0x31));
}

GSF__TARGET_AVX2 static inline __m128 gsf__sum4_avx2(__m256 a, __m256 b, __m256 c, __m256 d) {
    const __m256 abcd = _mm256_hadd_ps(_mm256_hadd_ps(a, b), _mm256_hadd_ps(c, d));
    return _mm_add_ps(_mm256_castps256_ps128(abcd), _mm256_extractf128_ps(abcd, 1));
}

GSF__INLINE_AVX2 void gsf__reverse_avx2_body(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads,
                                             size_t step_count, gsf__tile_gradient* gradient, float* slots,
                                             uint8_t* slot_used, int with_depth, int straight_through, int with_abs) {
    const __m256 alpha_max = _mm256_set1_ps(GSF__ALPHA_MAX);
    const __m256 magnitude = _mm256_castsi256_ps(_mm256_set1_epi32(0x7fffffff));
    for (size_t k = step_count; k > 0;) {
        const uint32_t entry = heads[k - 1].entry;
        const gsf__record* rec = tile->records + tile->splats[entry];
        const __m256 u = _mm256_set1_ps(rec->u - tile->x0 + rec->u_low), v = _mm256_set1_ps(rec->v - tile->y0 + rec->v_low);
        const __m256 kx = _mm256_set1_ps(rec->kx);
        const float conic_a = rec->ee * -1.3862944f, conic_q = rec->yy * -1.3862944f, conic_b = -rec->kx * conic_a;
        __m256 sp = _mm256_setzero_ps(), se = sp, see = sp, sy = sp, sey = sp, syy = sp, sr = sp, sg = sp, sb = sp, sz = sp;
        __m256 sax = sp, say = sp;
        for (; k > 0 && heads[k - 1].entry == entry; k--) {
            const gsf__step* step = steps + k - 1;
            const size_t s = heads[k - 1].step, at = 8 * s;
            const __m256 dy = _mm256_sub_ps(_mm256_loadu_ps(gsf__rows_of + 8 * (s & 7)), v);
            const __m256 e = _mm256_sub_ps(_mm256_loadu_ps(gsf__columns_of + 16 * (s >> 3)), _mm256_fmadd_ps(kx, dy, u));
            const __m256 raw = _mm256_loadu_ps(step->alpha), T = _mm256_loadu_ps(step->T);
            const __m256 gr = _mm256_loadu_ps(gradient->r + at), gg = _mm256_loadu_ps(gradient->g + at);
            const __m256 gb = _mm256_loadu_ps(gradient->b + at), behind = _mm256_loadu_ps(gradient->behind + at);
            const __m256 alpha = _mm256_min_ps(raw, alpha_max), w = _mm256_mul_ps(alpha, T);
            __m256 F = _mm256_fmsub_ps(_mm256_broadcast_ss(&rec->r), gr, behind);
            F = _mm256_fmadd_ps(_mm256_broadcast_ss(&rec->g), gg, F);
            F = _mm256_fmadd_ps(_mm256_broadcast_ss(&rec->b), gb, F);
            if (with_depth) {
                const __m256 gz = _mm256_loadu_ps(gradient->z + at);
                F = _mm256_add_ps(_mm256_fmadd_ps(_mm256_set1_ps(rec->depth), gz, F), _mm256_loadu_ps(gradient->a + at));
                sz = _mm256_fmadd_ps(w, gz, sz);
            }
            _mm256_storeu_ps(gradient->behind + at, _mm256_fmadd_ps(alpha, F, behind));
            const __m256 p = straight_through ? _mm256_mul_ps(_mm256_mul_ps(T, raw), F)
                                              : _mm256_and_ps(_mm256_mul_ps(w, F), _mm256_cmp_ps(raw, alpha_max, _CMP_LE_OQ));
            const __m256 pe = _mm256_mul_ps(p, e), py = _mm256_mul_ps(p, dy);
            sp = _mm256_add_ps(sp, p);
            se = _mm256_add_ps(se, pe);
            see = _mm256_fmadd_ps(pe, e, see);
            sy = _mm256_add_ps(sy, py);
            sey = _mm256_fmadd_ps(pe, dy, sey);
            syy = _mm256_fmadd_ps(py, dy, syy);
            sr = _mm256_fmadd_ps(w, gr, sr);
            sg = _mm256_fmadd_ps(w, gg, sg);
            sb = _mm256_fmadd_ps(w, gb, sb);
            if (with_abs) {
                const __m256 dv = _mm256_fmadd_ps(_mm256_set1_ps(conic_b), pe, _mm256_mul_ps(_mm256_set1_ps(conic_q), py));
                sax = _mm256_add_ps(sax, _mm256_and_ps(magnitude, pe));
                say = _mm256_add_ps(say, _mm256_and_ps(magnitude, dv));
            }
        }
        float* to = slots + GSF__SLOT_FLOATS * entry;
        const __m256 first = gsf__sum8_avx2(sp, se, see, sy, sey, syy, sr, sg);
        _mm256_storeu_ps(to, first); // complete: an entry's steps are all in one bucket
        _mm_storeu_ps(to + 8, gsf__sum4_avx2(sb, sz, _mm256_mul_ps(sax, _mm256_set1_ps(conic_a)), say));
        slot_used[entry] = 1;
    }
}

GSF__TARGET_AVX2 static void gsf__reverse_avx2(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads,
                                               size_t step_count, gsf__tile_gradient* gradient, float* slots,
                                               uint8_t* slot_used, int flags) {
    if (flags == 0)
        gsf__reverse_avx2_body(tile, steps, heads, step_count, gradient, slots, slot_used, 0, 0, 0);
    else if (flags == GSF__WITH_DEPTH)
        gsf__reverse_avx2_body(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 0, 0);
    else if (flags & GSF__STRAIGHT_THROUGH)
        gsf__reverse_avx2_body(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 1, 1);
    else
        gsf__reverse_avx2_body(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 0, 1);
}

// Horizontal sums of twelve vectors, in the first twelve lanes of the result; the others are finite if all are.
GSF__INLINE_AVX512 __m512 gsf__sum12_avx512(const __m512 v[12]) {
    __m512 pair[6], four[3];
    for (int i = 0; i < 6; i++) // halves of 2 i, then of 2 i + 1
        pair[i] = _mm512_add_ps(_mm512_shuffle_f32x4(v[2 * i], v[2 * i + 1], 0x44),
                                _mm512_shuffle_f32x4(v[2 * i], v[2 * i + 1], 0xee));
    for (int i = 0; i < 3; i++) // a quarter of each of 4 i .. 4 i + 3
        four[i] = _mm512_add_ps(_mm512_shuffle_f32x4(pair[2 * i], pair[2 * i + 1], 0x88),
                                _mm512_shuffle_f32x4(pair[2 * i], pair[2 * i + 1], 0xdd));
    const __m512 p = _mm512_add_ps(_mm512_unpacklo_ps(four[0], four[1]), _mm512_unpackhi_ps(four[0], four[1]));
    const __m512 q = _mm512_add_ps(_mm512_unpacklo_ps(four[2], four[2]), _mm512_unpackhi_ps(four[2], four[2]));
    const __m512 sums = _mm512_add_ps(_mm512_shuffle_ps(p, q, 0x44), _mm512_shuffle_ps(p, q, 0xee)); // 0 4 8 8, 1 5 9 9, ...
    const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 3, 3, 3);
    return _mm512_permutexvar_ps(order, sums);
}

GSF__INLINE_AVX512 void gsf__reverse_avx512_body(const gsf__tile* tile, const gsf__step* memory,
                                                 const gsf__step_head* heads, size_t step_count,
                                                 gsf__tile_gradient* gradient, float* slots, uint8_t* slot_used,
                                                 int with_depth, int straight_through, int with_abs) {
    const __m512 alpha_max = _mm512_set1_ps(GSF__ALPHA_MAX), zero = _mm512_setzero_ps();
    const gsf__wide_step* steps = (const gsf__wide_step*)(const void*)memory;
    for (size_t k = step_count; k > 0;) {
        const uint32_t entry = heads[k - 1].entry;
        const gsf__record* rec = tile->records + tile->splats[entry];
        const __m512 u = _mm512_set1_ps(rec->u - tile->x0 + rec->u_low), v = _mm512_set1_ps(rec->v - tile->y0 + rec->v_low);
        const __m512 kx = _mm512_set1_ps(rec->kx);
        const float conic_a = rec->ee * -1.3862944f, conic_q = rec->yy * -1.3862944f, conic_b = -rec->kx * conic_a;
        __m512 sp = zero, se = zero, see = zero, sy = zero, sey = zero, syy = zero, sr = zero, sg = zero, sb = zero;
        __m512 sz = zero, sax = zero, say = zero;
        for (; k > 0 && heads[k - 1].entry == entry; k--) {
            const gsf__wide_step* step = steps + k - 1;
            const size_t b = heads[k - 1].step, at = 16 * b;
            const __m512 dy = _mm512_sub_ps(_mm512_loadu_ps(gsf__rows_of + 16 * (b & 3)), v);
            const __m512 e = _mm512_sub_ps(_mm512_loadu_ps(gsf__columns_of + 16 * (b >> 2)), _mm512_fmadd_ps(kx, dy, u));
            const __m512 raw = _mm512_loadu_ps(step->alpha), T = _mm512_loadu_ps(step->T);
            const __m512 gr = _mm512_loadu_ps(gradient->r + at), gg = _mm512_loadu_ps(gradient->g + at);
            const __m512 gb = _mm512_loadu_ps(gradient->b + at), behind = _mm512_loadu_ps(gradient->behind + at);
            const __m512 alpha = _mm512_min_ps(raw, alpha_max), w = _mm512_mul_ps(alpha, T);
            __m512 F = _mm512_fmsub_ps(_mm512_set1_ps(rec->r), gr, behind);
            F = _mm512_fmadd_ps(_mm512_set1_ps(rec->g), gg, F);
            F = _mm512_fmadd_ps(_mm512_set1_ps(rec->b), gb, F);
            if (with_depth) {
                const __m512 gz = _mm512_loadu_ps(gradient->z + at);
                F = _mm512_add_ps(_mm512_fmadd_ps(_mm512_set1_ps(rec->depth), gz, F), _mm512_loadu_ps(gradient->a + at));
                sz = _mm512_fmadd_ps(w, gz, sz);
            }
            _mm512_storeu_ps(gradient->behind + at, _mm512_fmadd_ps(alpha, F, behind));
            const __m512 p = straight_through ? _mm512_mul_ps(_mm512_mul_ps(T, raw), F)
                                              : _mm512_maskz_mul_ps(_mm512_cmp_ps_mask(raw, alpha_max, _CMP_LE_OQ), w, F);
            const __m512 pe = _mm512_mul_ps(p, e), py = _mm512_mul_ps(p, dy);
            sp = _mm512_add_ps(sp, p);
            se = _mm512_add_ps(se, pe);
            see = _mm512_fmadd_ps(pe, e, see);
            sy = _mm512_add_ps(sy, py);
            sey = _mm512_fmadd_ps(pe, dy, sey);
            syy = _mm512_fmadd_ps(py, dy, syy);
            sr = _mm512_fmadd_ps(w, gr, sr);
            sg = _mm512_fmadd_ps(w, gg, sg);
            sb = _mm512_fmadd_ps(w, gb, sb);
            if (with_abs) {
                const __m512 dv = _mm512_fmadd_ps(_mm512_set1_ps(conic_b), pe, _mm512_mul_ps(_mm512_set1_ps(conic_q), py));
                sax = _mm512_add_ps(sax, _mm512_abs_ps(pe));
                say = _mm512_add_ps(say, _mm512_abs_ps(dv));
            }
        }
        const __m512 parts[12] = {sp, se, see, sy, sey, syy, sr, sg, sb, sz, _mm512_mul_ps(sax, _mm512_set1_ps(conic_a)), say};
        // complete: an entry's steps are all in one bucket
        _mm512_storeu_ps(slots + GSF__SLOT_FLOATS * entry, gsf__sum12_avx512(parts));
        slot_used[entry] = 1;
    }
}

GSF__TARGET_AVX512 static void gsf__reverse_avx512(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads,
                                                   size_t step_count, gsf__tile_gradient* gradient, float* slots,
                                                   uint8_t* slot_used, int flags) {
    if (flags == 0)
        gsf__reverse_avx512_body(tile, steps, heads, step_count, gradient, slots, slot_used, 0, 0, 0);
    else if (flags == GSF__WITH_DEPTH)
        gsf__reverse_avx512_body(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 0, 0);
    else if (flags & GSF__STRAIGHT_THROUGH)
        gsf__reverse_avx512_body(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 1, 1);
    else
        gsf__reverse_avx512_body(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 0, 1);
}

#endif // GSF__X86

#if GSF__SIMD128

static size_t gsf__keep_simd128(const gsf__tile* tile, float* T_tile, size_t first, size_t last, gsf__step* steps,
                                gsf__step_head* heads, size_t* step_count) {
    uint32_t live = gsf__live_simd128(T_tile);
    float center[GSF__TILE], exponent[GSF__TILE];
    size_t kept = 0, i = first;
    for (; i < last && live && kept <= GSF__BUCKET; i++) {
        const gsf__record* rec = tile->records + tile->splats[i];
        const float u = rec->u - tile->x0 + rec->u_low, v = rec->v - tile->y0 + rec->v_low;
        for (uint32_t m = gsf__rows_simd128(rec, u, v, center, exponent) & live; m; m &= m - 1) {
            const uint32_t s = (uint32_t)gsf__lowest_bit(m), row = 2 * (s & 7);
            float* T = T_tile + 8 * s;
            const gsf__pair_simd128 raw = gsf__alphas_simd128(rec->ee, center + row, exponent + row, s);
            gsf__vf_simd128 weight;
            gsf__vm_simd128 shown0, shown1;
            const gsf__vf_simd128 old0 = gsf__v_load_simd128(T), old1 = gsf__v_load_simd128(T + 4);
            const gsf__vf_simd128 T0 = gsf__next_simd128(old0, raw.low, &weight, &shown0);
            const gsf__vf_simd128 T1 = gsf__next_simd128(old1, raw.high, &weight, &shown1);
            gsf__v_store_simd128(T, T0);
            gsf__v_store_simd128(T + 4, T1);
            const gsf__vf_simd128 alpha0 = gsf__v_keep_simd128(shown0, raw.low), alpha1 = gsf__v_keep_simd128(shown1, raw.high);
            gsf__v_store_simd128(steps[kept].alpha, alpha0);
            gsf__v_store_simd128(steps[kept].alpha + 4, alpha1);
            gsf__v_store_simd128(steps[kept].T, old0);
            gsf__v_store_simd128(steps[kept].T + 4, old1);
            heads[kept].entry = (uint32_t)i;
            heads[kept].step = s;
            kept += (size_t)gsf__any_positive_simd128(alpha0 + alpha1);
            if (!gsf__is_open_simd128(T0, T1)) live &= ~(1u << s);
        }
    }
    *step_count = kept;
    return live && i < last ? i : tile->count;
}

GSF__INLINE_SIMD128 void gsf__reverse_body_simd128(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads,
                                                   size_t step_count, gsf__tile_gradient* gradient, float* slots,
                                                   uint8_t* slot_used, int with_depth, int straight_through, int with_abs) {
    const gsf__vf_simd128 alpha_max = gsf__v_set_simd128(GSF__ALPHA_MAX), zero = gsf__v_set_simd128(0.0f);
    for (size_t k = step_count; k > 0;) {
        const uint32_t entry = heads[k - 1].entry;
        const gsf__record* rec = tile->records + tile->splats[entry];
        const gsf__vf_simd128 u = gsf__v_set_simd128(rec->u - tile->x0 + rec->u_low);
        const gsf__vf_simd128 v = gsf__v_set_simd128(rec->v - tile->y0 + rec->v_low), kx = gsf__v_set_simd128(rec->kx);
        const float conic_a = rec->ee * -1.3862944f, conic_q = rec->yy * -1.3862944f, conic_b = -rec->kx * conic_a;
        gsf__vf_simd128 sum[GSF__SLOT_SUMS];
        for (int i = 0; i < GSF__SLOT_SUMS; i++) sum[i] = zero;
        for (; k > 0 && heads[k - 1].entry == entry; k--) {
            const gsf__step* step = steps + k - 1;
            const size_t s = heads[k - 1].step;
            for (size_t half = 0; half < 8; half += 4) {
                const size_t at = 8 * s + half;
                const gsf__vf_simd128 dy = gsf__v_load_simd128(gsf__rows_of + 8 * (s & 7) + half) - v;
                const gsf__vf_simd128 e = gsf__v_load_simd128(gsf__columns_of + 16 * (s >> 3) + half) -
                                          gsf__v_madd_simd128(kx, dy, u);
                const gsf__vf_simd128 raw = gsf__v_load_simd128(step->alpha + half), T = gsf__v_load_simd128(step->T + half);
                const gsf__vf_simd128 gr = gsf__v_load_simd128(gradient->r + at), gg = gsf__v_load_simd128(gradient->g + at);
                const gsf__vf_simd128 gb = gsf__v_load_simd128(gradient->b + at);
                const gsf__vf_simd128 behind = gsf__v_load_simd128(gradient->behind + at);
                const gsf__vf_simd128 alpha = gsf__least_simd128(raw, alpha_max), w = alpha * T;
                gsf__vf_simd128 F = gsf__v_msub_simd128(gsf__v_set_simd128(rec->r), gr, behind);
                F = gsf__v_madd_simd128(gsf__v_set_simd128(rec->g), gg, F);
                F = gsf__v_madd_simd128(gsf__v_set_simd128(rec->b), gb, F);
                if (with_depth) {
                    const gsf__vf_simd128 gz = gsf__v_load_simd128(gradient->z + at);
                    F = gsf__v_madd_simd128(gsf__v_set_simd128(rec->depth), gz, F) + gsf__v_load_simd128(gradient->a + at);
                    sum[GSF__SLOT_Z] = gsf__v_madd_simd128(w, gz, sum[GSF__SLOT_Z]);
                }
                gsf__v_store_simd128(gradient->behind + at, gsf__v_madd_simd128(alpha, F, behind));
                gsf__vf_simd128 p = T * raw * F;
                if (!straight_through) p = gsf__v_keep_simd128(gsf__v_le_simd128(raw, alpha_max), p);
                const gsf__vf_simd128 pe = p * e, py = p * dy;
                sum[GSF__SLOT_P] = sum[GSF__SLOT_P] + p;
                sum[GSF__SLOT_E] = sum[GSF__SLOT_E] + pe;
                sum[GSF__SLOT_EE] = gsf__v_madd_simd128(pe, e, sum[GSF__SLOT_EE]);
                sum[GSF__SLOT_Y] = sum[GSF__SLOT_Y] + py;
                sum[GSF__SLOT_EY] = gsf__v_madd_simd128(pe, dy, sum[GSF__SLOT_EY]);
                sum[GSF__SLOT_YY] = gsf__v_madd_simd128(py, dy, sum[GSF__SLOT_YY]);
                sum[GSF__SLOT_R] = gsf__v_madd_simd128(w, gr, sum[GSF__SLOT_R]);
                sum[GSF__SLOT_G] = gsf__v_madd_simd128(w, gg, sum[GSF__SLOT_G]);
                sum[GSF__SLOT_B] = gsf__v_madd_simd128(w, gb, sum[GSF__SLOT_B]);
                if (with_abs) {
                    const gsf__vf_simd128 dv = gsf__v_madd_simd128(gsf__v_set_simd128(conic_b), pe,
                                                                   gsf__v_set_simd128(conic_q) * py);
                    sum[GSF__SLOT_ABS_X] = sum[GSF__SLOT_ABS_X] + gsf__v_abs_simd128(pe);
                    sum[GSF__SLOT_ABS_Y] = sum[GSF__SLOT_ABS_Y] + gsf__v_abs_simd128(dv);
                }
            }
        }
        sum[GSF__SLOT_ABS_X] = sum[GSF__SLOT_ABS_X] * gsf__v_set_simd128(conic_a);
        for (int i = 0; i < GSF__SLOT_SUMS; i += 4) { // complete: an entry's steps are all in one bucket
            gsf__v_transpose_simd128(sum + i);
            gsf__v_store_simd128(slots + GSF__SLOT_FLOATS * entry + i, (sum[i] + sum[i + 2]) + (sum[i + 1] + sum[i + 3]));
        }
        slot_used[entry] = 1;
    }
}

static void gsf__reverse_simd128(const gsf__tile* tile, const gsf__step* steps, const gsf__step_head* heads, size_t step_count,
                                 gsf__tile_gradient* gradient, float* slots, uint8_t* slot_used, int flags) {
    if (flags == 0)
        gsf__reverse_body_simd128(tile, steps, heads, step_count, gradient, slots, slot_used, 0, 0, 0);
    else if (flags == GSF__WITH_DEPTH)
        gsf__reverse_body_simd128(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 0, 0);
    else if (flags & GSF__STRAIGHT_THROUGH)
        gsf__reverse_body_simd128(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 1, 1);
    else
        gsf__reverse_body_simd128(tile, steps, heads, step_count, gradient, slots, slot_used, 1, 0, 1);
}

#endif // GSF__SIMD128

static gsf__raster_kernels gsf__raster_kernels_of(gsf_cpu_level level) {
    const gsf__raster_kernels kernels = {GSF__ANY_KERNEL_OF(level, gsf__blend), GSF__ANY_KERNEL_OF(level, gsf__keep),
                                         GSF__ANY_KERNEL_OF(level, gsf__reverse)};
    return kernels;
}

// ---- >>project backward --------------------------------------------------------

#endif // GSF__ISA
#ifdef GSF__KERNELS_SPLATS

// Derivative of sum(weight * basis) with respect to the direction, without that of the normalisation. count >= 4.
GSF__V_INLINE void GSF__V(gsf__sh_direction_gradient)(const gsf__vf d[3], int32_t count, const gsf__vf weight[16],
                                                      gsf__vf out[3]) {
    const gsf__vf x = d[0], y = d[1], z = d[2];
    const gsf__vf two = gsf__v_set(2.0f), three = gsf__v_set(3.0f), four = gsf__v_set(4.0f);
    out[0] = gsf__v_set(-0.4886025119029199f) * weight[3];
    out[1] = gsf__v_set(-0.4886025119029199f) * weight[1];
    out[2] = gsf__v_set(0.4886025119029199f) * weight[2];
    if (count < 9) return;
    const gsf__vf c4 = gsf__v_set(1.0925484305920792f), c6 = gsf__v_set(0.6307831305050401f);
    out[0] = out[0] + c4 * (y * weight[4] - z * weight[7] + x * weight[8]) - c6 * x * weight[6];
    out[1] = out[1] + c4 * (x * weight[4] - z * weight[5] - y * weight[8]) - c6 * y * weight[6];
    out[2] = out[2] - c4 * (y * weight[5] + x * weight[7]) + two * c6 * z * weight[6];
    if (count < 16) return;
    const gsf__vf xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    const gsf__vf a = gsf__v_set(0.5900435899266435f), b = gsf__v_set(2.890611442640554f);
    const gsf__vf c = gsf__v_set(0.4570457994644658f), e = gsf__v_set(0.3731763325901154f);
    const gsf__vf six = gsf__v_set(6.0f), eight = gsf__v_set(8.0f);
    out[0] = out[0] - six * a * xy * weight[9] + b * yz * weight[10] + two * c * xy * weight[11] -
             six * e * xz * weight[12] - c * (four * zz - three * xx - yy) * weight[13] + b * xz * weight[14] -
             three * a * (xx - yy) * weight[15];
    out[1] = out[1] - three * a * (xx - yy) * weight[9] + b * xz * weight[10] -
             c * (four * zz - xx - three * yy) * weight[11] - six * e * yz * weight[12] + two * c * xy * weight[13] -
             b * yz * weight[14] + six * a * xy * weight[15];
    out[2] = out[2] + b * xy * weight[10] - eight * c * yz * weight[11] + three * e * (two * zz - xx - yy) * weight[12] -
             eight * c * xz * weight[13] + gsf__v_set(1.445305721320277f) * (xx - yy) * weight[14];
}

// Adds the first `count` lanes to one column of an array of rows.
GSF__V_INLINE void GSF__V(gsf__add_column)(float* rows, size_t stride, gsf__vf value, size_t count) {
    float lanes[GSF__LANES];
    gsf__v_store(lanes, value);
    for (size_t l = 0; l < count; l++) rows[stride * l] += lanes[l];
}

// Sums the slots of each splat from i on, in double and in tile order, into the first GSF__SLOT_SUMS columns. Returns
// a bit for every splat that has a slot in use.
GSF__V_INLINE uint32_t GSF__V(gsf__sum_slots)(const gsf_rasterizer* r, size_t i, size_t count, gsf__vf columns[16]) {
    enum { WIDE = GSF__LANES / GSF__HALVES, PARTS = (GSF__SLOT_SUMS + WIDE - 1) / WIDE };
    uint32_t touched = 0;
    for (size_t l = 0; l < GSF__LANES; l++) {
        gsf__vd sums[16 / WIDE];
        for (size_t k = 0; k < 16 / WIDE; k++) sums[k] = gsf__vd_set(0.0);
        if (l < count && r->records[i + l].radius > 0) {
            for (size_t s = r->splat_begin[i + l]; s < r->splat_begin[i + l + 1]; s++) {
                const size_t entry = r->splat_entries[s];
                if (!r->slot_used[entry]) continue;
                const float* slot = r->slots + GSF__SLOT_FLOATS * entry;
                for (size_t k = 0; k < PARTS; k++) sums[k] = sums[k] + gsf__vd_load(slot + WIDE * k);
                touched |= 1u << l;
            }
        }
        for (size_t k = 0; k < GSF__SLOT_SUMS; k += GSF__LANES) columns[k + l] = gsf__vd_floats(sums + k / WIDE);
    }
    for (size_t k = 0; k < GSF__SLOT_SUMS; k += GSF__LANES) gsf__v_transpose(columns + k);
    return touched;
}

// Prefetches rows of `width` floats of the splats from i on.
GSF__V_INLINE void GSF__V(gsf__fetch_rows)(const float* rows, size_t width, size_t i) {
    for (size_t at = width * i; at < width * (i + GSF__LANES) && rows; at += 16) gsf__v_fetch(rows + at);
}

// Prefetches data of the splats from i on: their slots are scattered over memory, and all else is more streams than the
// processor follows.
GSF__V_INLINE void GSF__V(gsf__gather_ahead)(const gsf_rasterizer* r, const gsf__view* view, const gsf_splats* splats,
                                             const gsf_splat_grads* grads, size_t i) {
    for (size_t s = r->splat_begin[i]; s < r->splat_begin[i + GSF__LANES]; s++) {
        const float* slot = r->slots + GSF__SLOT_FLOATS * r->splat_entries[s];
        gsf__v_fetch(slot);
    }
    for (size_t l = 0; l < GSF__LANES; l++) gsf__v_fetch(&r->records[i + l].u);
    GSF__V(gsf__fetch_rows)(splats->means, 3, i);
    GSF__V(gsf__fetch_rows)(splats->log_scales, 3, i);
    GSF__V(gsf__fetch_rows)(splats->quats, 4, i);
    GSF__V(gsf__fetch_rows)(splats->opacity_logits, 1, i);
    GSF__V(gsf__fetch_rows)(grads->means, 3, i);
    GSF__V(gsf__fetch_rows)(grads->log_scales, 3, i);
    GSF__V(gsf__fetch_rows)(grads->quats, 4, i);
    GSF__V(gsf__fetch_rows)(grads->opacity_logits, 1, i);
    const size_t row = 3 * (size_t)gsf_splat_count_sh(splats->sh_degree), used = 3 * (size_t)view->sh_coefficients;
    for (size_t at = row * i, end = at + GSF__LANES * row; at < end; at += row)
        for (size_t k = 0; k < used; k += 16) {
            if (used > 3) gsf__v_fetch(splats->sh + at + k);
            if (grads->sh) gsf__v_fetch(grads->sh + at + k);
        }
}

// Gradients of the splats from i on: backpropagates the sums of their slots through covariance, projection and colour.
GSF__V_KERNEL void GSF__V(gsf__gather)(const gsf_rasterizer* r, const gsf__view* view, const gsf_splats* splats,
                                       const gsf_splat_grads* grads, size_t i, size_t left) {
    const size_t count = left < GSF__LANES ? left : GSF__LANES;
    if (left >= 2 * GSF__LANES) GSF__V(gsf__gather_ahead)(r, view, splats, grads, i + GSF__LANES);
    gsf__vf sums[16];
    const uint32_t touched = GSF__V(gsf__sum_slots)(r, i, count, sums);
    if (!touched) return;
    const gsf__vi lane = GSF__V(gsf__splat_lanes)(left);
    const gsf__vf one = gsf__v_set(1.0f), two = gsf__v_set(2.0f), four = gsf__v_set(4.0f), zero = gsf__v_set(0.0f);
    gsf__projection p;
    const gsf__vm live = gsf__vm_and(GSF__V(gsf__project)(view, splats, i, lane, &p), gsf__vm_of_bits(touched));
    if (!gsf__v_any(live)) return;
    const gsf__vf sp = sums[GSF__SLOT_P], se = sums[GSF__SLOT_E], see = sums[GSF__SLOT_EE];
    const gsf__vf sy = sums[GSF__SLOT_Y], sey = sums[GSF__SLOT_EY], syy = sums[GSF__SLOT_YY];
    const gsf__vf a = p.cov_c / p.det, q = one / p.cov_c, b = zero - p.cov_b * q * a; // inverse covariance

    // ln alpha = -1/2 (a e^2 + q dy^2): derivatives with respect to the screen mean
    const gsf__vf du = a * se, dv = b * se + q * sy;
    // and to V (cov = V V^T + blur): sum p (K d)(K d)^T V. With K d = (a e, b e + q dy), K V_c = (a g_c, b g_c + q V1c)
    // and g = V0 - kx V1, all sums have terms of similar size. g itself is computed from the minors n = V0 x V1 as
    // cov_c g = blur V0 + V1 x n, because for a needle the plain difference cancels completely.
    const gsf__vf *V0 = p.V, *V1 = p.V + 3;
    gsf__vf n[3], V1_n[3], n_V0[3], g[3], dV[6], d_log_scale[3];
    for (int c = 0; c < 3; c++) {
        const int c1 = (c + 1) % 3, c2 = (c + 2) % 3;
        n[c] = gsf__v_minor(V0[c1], V0[c2], V1[c1], V1[c2]);
    }
    for (int c = 0; c < 3; c++) {
        const int c1 = (c + 1) % 3, c2 = (c + 2) % 3;
        V1_n[c] = gsf__v_minor(V1[c1], V1[c2], n[c1], n[c2]);
        n_V0[c] = gsf__v_minor(n[c1], n[c2], V0[c1], V0[c2]);
        g[c] = (gsf__v_set(GSF__BLUR) * V0[c] + V1_n[c]) * q;
        const gsf__vf ag = a * g[c], qv = q * V1[c], along_e = ag * see + qv * sey;
        dV[c] = a * along_e;
        dV[3 + c] = b * along_e + q * (ag * sey + qv * syy);
        d_log_scale[c] = ag * ag * see + two * ag * qv * sey + qv * qv * syy; // (K d . V_c)^2
    }
    if (view->antialiased) {
        // ln compensation = 1/2 (ln det_raw - ln det). Derivatives of 1/2 ln det_raw: V1 x n / det_raw with respect to
        // V0, 1 - n_c^2 / det_raw with respect to ln s_c.
        const gsf__vm shrunk = gsf__v_gt(p.det_raw, gsf__v_set(GSF__AA_FLOOR) * p.det);
        const gsf__vf by_det = gsf__v_keep(shrunk, sp), raw = gsf__v_keep(shrunk, sp / p.det_raw);
        for (int c = 0; c < 3; c++) {
            const int c1 = (c + 1) % 3, c2 = (c + 2) % 3;
            dV[c] = dV[c] + raw * V1_n[c] - by_det * a * g[c];
            dV[3 + c] = dV[3 + c] + raw * n_V0[c] - by_det * (b * g[c] + q * V1[c]);
            d_log_scale[c] = d_log_scale[c] + raw * (n[c1] * n[c1] + n[c2] * n[c2]) -
                             by_det * (a * g[c] * g[c] + q * V1[c] * V1[c]);
        }
    }

    // V = J T with rows jx (T0 - x T2), jy (T1 - y T2)
    const gsf__vf inv_z = one / p.t[2], jx = gsf__v_set(view->fx) * inv_z, jy = gsf__v_set(view->fy) * inv_z;
    gsf__vf dT[9], d_jx = zero, d_jy = zero, d_x = zero, d_y = zero;
    for (int c = 0; c < 3; c++) {
        d_jx = d_jx + dV[c] * (p.T[c] - p.x * p.T[6 + c]);
        d_jy = d_jy + dV[3 + c] * (p.T[3 + c] - p.y * p.T[6 + c]);
        d_x = d_x - dV[c] * jx * p.T[6 + c];
        d_y = d_y - dV[3 + c] * jy * p.T[6 + c];
        dT[c] = jx * dV[c];
        dT[3 + c] = jy * dV[3 + c];
        dT[6 + c] = zero - jx * p.x * dV[c] - jy * p.y * dV[3 + c];
    }

    // mean in camera space: through u, v, the focal scale jx = fx/z and the slope x = t.x/z (constant where clamped;
    // there the Inria 3DGS code treats t.x = x z as constant instead, which leaves -x/z)
    const gsf__vf free_x = gsf__v_keep(gsf__vm_not(p.clamped_x), d_x) * inv_z;
    const gsf__vf free_y = gsf__v_keep(gsf__vm_not(p.clamped_y), d_y) * inv_z;
    gsf__vf slope_x = free_x, slope_y = free_y;
    if (view->official_gradient) {
        slope_x = d_x * inv_z;
        slope_y = d_y * inv_z;
    }
    gsf__vf d_t[3], d_mean[3];
    d_t[0] = du * jx + free_x;
    d_t[1] = dv * jy + free_y;
    d_t[2] = sums[GSF__SLOT_Z] - slope_x * p.x - slope_y * p.y -
             (du * jx * p.t[0] + dv * jy * p.t[1] + d_jx * jx + d_jy * jy) * inv_z;
    for (int c = 0; c < 3; c++)
        d_mean[c] = gsf__v_dot(gsf__v_set(view->W[c]), gsf__v_set(view->W[3 + c]), gsf__v_set(view->W[6 + c]), d_t[0],
                               d_t[1], d_t[2]);

    // colour
    const int32_t bands = view->sh_coefficients;
    const int stored = 3 * gsf_splat_count_sh(splats->sh_degree);
    gsf__vf d_rgb[3], d[3], basis[16];
    for (int c = 0; c < 3; c++) {
        const gsf__vf shown = gsf__v_column(&r->records[i].r, lane, sizeof(gsf__record) / sizeof(float), c);
        d_rgb[c] = gsf__v_keep(gsf__vm_and(live, gsf__v_gt(shown, zero)), sums[GSF__SLOT_R + c]);
    }
    const gsf__vf distance = GSF__V(gsf__view_direction)(view, splats, i, lane, d);
    for (int c = 0; c < 3; c++) d[c] = gsf__v_keep(live, d[c]); // a NaN would survive multiplication by a gradient of 0
    GSF__V(gsf__sh_basis)(d[0], d[1], d[2], bands, basis);
    if (grads->sh) {
        float* rows = grads->sh + (size_t)stored * i;
        gsf__vf d_sh[48];
        int k = 0;
        for (int band = 0; band < bands; band++)
            for (int c = 0; c < 3; c++) d_sh[k++] = basis[band] * d_rgb[c];
        for (; k % GSF__LANES; k++) d_sh[k] = zero;
        for (k = 0; k < 3 * bands && k + GSF__LANES <= stored; k += GSF__LANES) {
            gsf__v_transpose(d_sh + k);
            for (size_t l = 0; l < count; l++) {
                float* row = rows + (size_t)stored * l + k;
                if (touched >> l & 1u) gsf__v_store(row, gsf__v_load(row) + d_sh[k + (int)l]);
            }
        }
        for (; k < 3 * bands; k++) GSF__V(gsf__add_column)(rows + k, (size_t)stored, d_sh[k], count);
    }
    if (grads->means) {
        if (bands > 1) {
            gsf__vf sh[48], weight[16], d_dir[3];
            GSF__V(gsf__sh_columns)(splats, i, lane, 3 * bands, sh);
            for (int k = 1; k < bands; k++)
                weight[k] = gsf__v_dot(sh[3 * k], sh[3 * k + 1], sh[3 * k + 2], d_rgb[0], d_rgb[1], d_rgb[2]);
            GSF__V(gsf__sh_direction_gradient)(d, bands, weight, d_dir);
            const gsf__vf along = gsf__v_dot(d[0], d[1], d[2], d_dir[0], d_dir[1], d_dir[2]);
            const gsf__vm apart = gsf__v_gt(distance, zero); // direction = (mean - centre) / distance
            for (int c = 0; c < 3; c++) d_mean[c] = d_mean[c] + gsf__v_keep(apart, (d_dir[c] - along * d[c]) / distance);
        }
        for (size_t c = 0; c < 3; c++)
            GSF__V(gsf__add_column)(grads->means + 3 * i + c, 3, gsf__v_keep(live, d_mean[c]), count);
    }
    if (grads->means2d) {
        GSF__V(gsf__add_column)(grads->means2d + 2 * i, 2, gsf__v_keep(live, du), count);
        GSF__V(gsf__add_column)(grads->means2d + 2 * i + 1, 2, gsf__v_keep(live, dv), count);
    }
    if (grads->means2d_abs) {
        GSF__V(gsf__add_column)(grads->means2d_abs + 2 * i, 2, gsf__v_keep(live, sums[GSF__SLOT_ABS_X]), count);
        GSF__V(gsf__add_column)(grads->means2d_abs + 2 * i + 1, 2, gsf__v_keep(live, sums[GSF__SLOT_ABS_Y]), count);
    }
    if (grads->opacity_logits) { // d ln(sigmoid) / d logit = 1 - sigmoid = sigmoid(-logit)
        const gsf__vf d_logit = sp * GSF__V(gsf__sigmoid)(zero - p.logit);
        GSF__V(gsf__add_column)(grads->opacity_logits + i, 1, gsf__v_keep(live, d_logit), count);
    }
    if (grads->log_scales)
        for (size_t c = 0; c < 3; c++)
            GSF__V(gsf__add_column)(grads->log_scales + 3 * i + c, 3, gsf__v_keep(live, d_log_scale[c]), count);
    if (grads->quats) {
        gsf__vf dR[9], dq[4]; // T = Q S, Q = W R: W^T dQ, dQ = dT S
        for (int row = 0; row < 3; row++)
            for (int c = 0; c < 3; c++)
                dR[3 * row + c] = p.scale[c] * gsf__v_dot(gsf__v_set(view->W[row]), gsf__v_set(view->W[3 + row]),
                                                          gsf__v_set(view->W[6 + row]), dT[c], dT[3 + c], dT[6 + c]);
        const gsf__vf w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
        dq[0] = two * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
        dq[1] = two * (y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) + w * (dR[7] - dR[5])) - four * x * (dR[4] + dR[8]);
        dq[2] = two * (x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) + w * (dR[2] - dR[6])) - four * y * (dR[0] + dR[8]);
        dq[3] = two * (x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) + w * (dR[3] - dR[1])) - four * z * (dR[0] + dR[4]);
        const gsf__vf along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;
        for (size_t k = 0; k < 4; k++) {
            const gsf__vf d_quat = (dq[k] - along * p.q[k]) * p.inv_norm;
            GSF__V(gsf__add_column)(grads->quats + 4 * i + k, 4, gsf__v_keep(live, d_quat), count);
        }
    }
}

#endif // GSF__KERNELS_SPLATS
#ifndef GSF__ISA

// In index order, so that parameters and gradients stream through the cache.
static void gsf__gather_chunk(void* arg, size_t chunk, int32_t worker) {
    (void)worker;
    const gsf__splat_loop* job = (const gsf__splat_loop*)arg;
    const size_t end = gsf__splat_chunk_end(job->r, chunk);
    for (size_t i = chunk * GSF__PROJECT_CHUNK; i < end; i += GSF__ANY_KERNEL_OF(job->level, GSF__LANES))
        GSF__ANY_KERNEL_OF(job->level, gsf__gather)(job->r, job->view, job->splats, job->grads, i, end - i);
}

// ---- >>render ------------------------------------------------------------------

static gsf_result gsf__check_render(gsf_context* ctx, const gsf_splats* splats, const gsf_camera* camera,
                                    const gsf_render_desc* desc) {
    GSF__TRY(gsf_check_camera(ctx, camera));
    if (splats->count > UINT32_MAX - 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render: %zu splats are more than 2^32 - 2", splats->count);
    if (splats->sh_degree < 0 || splats->sh_degree > 3)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render: SH degree %d is not 0..3", (int)splats->sh_degree);
    if (splats->count && !(splats->means && splats->log_scales && splats->quats && splats->opacity_logits && splats->sh))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render: a parameter array is NULL");
    GSF__CHECK_CANARIES(ctx, "render", desc);
    if (desc->sh_bands < 0 || desc->sh_bands > 4)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render: sh_bands is %d, expected 0..4", (int)desc->sh_bands);
    if (camera->width > 65536 || camera->height > 65536)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render: image of %d x %d is larger than 65536 x 65536",
                        (int)camera->width, (int)camera->height);
    for (int c = 0; c < 3; c++)
        if (!isfinite(desc->background[c]))
            return gsf_fail(ctx, GSF_ERROR_NUMERIC, "render: background[%d] is not finite", c);
    return GSF_OK;
}

static gsf_result gsf__check_output(gsf_context* ctx, const gsf_image* image, const char* name, int channels,
                                    const gsf_camera* camera) {
    if (!image->data) return GSF_OK;
    if (image->dtype != GSF_F32 || image->channels != channels || image->width != camera->width ||
        image->height != camera->height)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render: output %s must be f32, %d channels, %d x %d", name,
                        channels, (int)camera->width, (int)camera->height);
    return GSF_OK;
}

static gsf_result gsf__reserve_frame(gsf_context* ctx, gsf_rasterizer* r) {
    const size_t pixels = (size_t)r->width * (size_t)r->height;
    if (pixels > r->pixel_capacity) {
        r->pixel_capacity = 0;
        GSF__TRY(gsf__grow(ctx, (void**)&r->final_T, pixels, sizeof(float)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->depth_sum, pixels, sizeof(float)));
        r->pixel_capacity = pixels;
    }
    if (r->splat_count > r->splat_capacity || !r->radii) {
        const size_t n = r->splat_count + r->splat_count / 4 + 64;
        r->splat_capacity = 0;
        GSF__TRY(gsf__grow(ctx, (void**)&r->records, n, sizeof(gsf__record)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->radii, n, sizeof(int32_t)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->splat_begin, n + 1, sizeof(size_t)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->order, n, sizeof(uint64_t)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->order_spare, n, sizeof(uint64_t)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->rows, n, sizeof(gsf__tile_span)));
        r->splat_capacity = n;
    }
    return GSF_OK;
}

typedef struct gsf__raster_job {
    gsf_rasterizer* r;
    gsf__raster_kernels kernels;
    const gsf__view* view;
    const gsf_render_output* out;
    const float *d_color, *d_depth, *d_alpha;
    int flags, wants_background;
} gsf__raster_job;

static gsf__tile gsf__tile_of(const gsf_rasterizer* r, size_t index) {
    gsf__tile tile;
    tile.records = r->records;
    tile.splats = r->entries + r->tile_begin[index];
    tile.count = r->tile_begin[index + 1] - r->tile_begin[index];
    tile.x0 = (float)((int32_t)(index % (size_t)r->tiles_x) * GSF__TILE);
    tile.y0 = (float)((int32_t)(index / (size_t)r->tiles_x) * GSF__TILE);
    return tile;
}

// Number of columns and rows of the tile that lie inside the image.
static void gsf__tile_extent(const gsf_rasterizer* r, const gsf__tile* tile, int* columns, int* rows) {
    *columns = r->width - (int)tile->x0 < GSF__TILE ? r->width - (int)tile->x0 : GSF__TILE;
    *rows = r->height - (int)tile->y0 < GSF__TILE ? r->height - (int)tile->y0 : GSF__TILE;
}

// Index in the arrays of a tile of the pixel in column x, row y; the next pixels of its row and strip follow at distance 2.
static int gsf__tile_pixel(int x, int y) {
    return GSF__STRIP * GSF__TILE * (x / GSF__STRIP) + 8 * (y / 2) + y % 2 + 2 * (x % GSF__STRIP);
}

// Number of pixels of a row of strip k that lie inside the image, 0..4.
static int gsf__strip_width(int k, int columns) {
    const int left = columns - GSF__STRIP * k;
    return left <= 0 ? 0 : left < GSF__STRIP ? left : GSF__STRIP;
}

// T = 1 inside the image, -1 (finished) outside.
static void gsf__open_tile(float* T, int columns, int rows) {
    for (int i = 0; i < GSF__TILE_PIXELS; i++) T[i] = 1.0f;
    for (int y = 0; y < GSF__TILE && (columns < GSF__TILE || rows < GSF__TILE); y++)
        for (int x = y < rows ? columns : 0; x < GSF__TILE; x++)
            T[gsf__tile_pixel(x, y)] = -1.0f;
}

static void gsf__put_pixel(const gsf_image* image, int64_t x, int64_t y, int channel, float value) {
    char* at = (char*)image->data + y * image->stride_y + x * image->stride_x + channel * image->stride_c;
    memcpy(at, &value, sizeof value);
}

static float gsf__get_pixel(const gsf_image* image, int64_t x, int64_t y, int channel) {
    float value;
    memcpy(&value, (const char*)image->data + y * image->stride_y + x * image->stride_x + channel * image->stride_c,
           sizeof value);
    return value;
}

// The colours of a tile's row over the background, and their T.
static inline void gsf__row_colors(const gsf__tile_state* state, int row, const float background[3], float* rgb, float* T) {
    for (int strip = 0; strip < GSF__TILE / GSF__STRIP; strip++) {
        const int from = gsf__tile_pixel(GSF__STRIP * strip, row);
        for (int k = from; k < from + 2 * GSF__STRIP; k += 2, T++, rgb += 3) {
            const float behind = fabsf(state->T[k]);
            *T = behind;
            rgb[0] = state->r[k] + behind * background[0];
            rgb[1] = state->g[k] + behind * background[1];
            rgb[2] = state->b[k] + behind * background[2];
        }
    }
}

static void gsf__blend_chunk(void* arg, size_t index, int32_t worker) {
    (void)worker;
    const gsf__raster_job* job = (const gsf__raster_job*)arg;
    gsf_rasterizer* r = job->r;
    const gsf__tile tile = gsf__tile_of(r, index);
    gsf__tile_state state;
    int columns, rows;
    gsf__tile_extent(r, &tile, &columns, &rows);
    memset(&state, 0, sizeof state);
    gsf__open_tile(state.T, columns, rows);
    const gsf_image *color = &job->out->color, *depth = &job->out->depth, *alpha = &job->out->alpha;
    const int packed = color->stride_c == sizeof(float) && color->stride_x == 3 * sizeof(float);
    for (int row = 0; row < rows; row++) { // to be written after the blending
        const int64_t x0 = (int64_t)tile.x0, y = (int64_t)tile.y0 + row;
        gsf__v_fetch_scalar(r->final_T + (size_t)y * (size_t)r->width + (size_t)x0);
        const char* line = (const char*)color->data;
        for (int x = 0; x < columns && packed && line; x += 5) // 60 bytes each
            gsf__v_fetch_scalar((const float*)(const void*)(line + y * color->stride_y + (x0 + x) * color->stride_x));
    }
    job->kernels.blend(&tile, &state, job->flags);
    for (int row = 0; row < rows; row++) {
        const int64_t x0 = (int64_t)tile.x0, y = (int64_t)tile.y0 + row;
        const size_t pixel = (size_t)y * (size_t)r->width + (size_t)x0;
        float rgb[3 * GSF__TILE], T_row[GSF__TILE], *T = T_row;
        if (columns == GSF__TILE && packed && color->data) { // most rows
            T = r->final_T + pixel;
            gsf__row_colors(&state, row, job->view->background,
                            (float*)(void*)((char*)color->data + y * color->stride_y + x0 * color->stride_x), T);
        } else {
            gsf__row_colors(&state, row, job->view->background, rgb, T);
            memcpy(r->final_T + pixel, T, (size_t)columns * sizeof(float));
            for (int k = 0; k < 3 * columns && color->data; k++) gsf__put_pixel(color, x0 + k / 3, y, k % 3, rgb[k]);
        }
        for (int x = 0; x < columns && (r->has_depth || alpha->data || depth->data); x++) {
            const float a = 1.0f - T[x], z = state.z[gsf__tile_pixel(x, row)];
            if (r->has_depth) r->depth_sum[pixel + (size_t)x] = z;
            if (alpha->data) gsf__put_pixel(alpha, x0 + x, y, 0, a);
            if (depth->data) gsf__put_pixel(depth, x0 + x, y, 0, T[x] < 1.0f ? z / a : 0.0f);
        }
    }
}

GSF_API gsf_result gsf_splat_render(gsf_context* ctx, gsf_rasterizer* r, const gsf_splats* splats, const gsf_camera* camera,
                                    const gsf_render_desc* desc, const gsf_render_output* out) {
    gsf_render_desc defaults;
    memset(&defaults, 0, sizeof defaults);
    if (!desc) desc = &defaults;
    GSF__TRY(gsf__check_render(ctx, splats, camera, desc));
    GSF__TRY(gsf__check_output(ctx, &out->color, "color", 3, camera));
    GSF__TRY(gsf__check_output(ctx, &out->depth, "depth", 1, camera));
    GSF__TRY(gsf__check_output(ctx, &out->alpha, "alpha", 1, camera));
    r->width = camera->width;
    r->height = camera->height;
    r->tiles_x = (r->width + GSF__TILE - 1) / GSF__TILE;
    r->tiles_y = (r->height + GSF__TILE - 1) / GSF__TILE;
    r->splat_count = splats->count;
    r->has_depth = out->depth.data != NULL;
    GSF__TRY(gsf__reserve_frame(ctx, r));

    const gsf__view view = gsf__make_view(splats, camera, desc);
    gsf__splat_loop project = {r, &view, splats, desc->hidden, NULL, ctx->cpu_level};
    gsf__parallel_for(ctx, gsf__splat_chunks(r), gsf__project_chunk, &project);
    GSF__TRY(gsf__order(ctx, r));
    GSF__TRY(gsf__bin(ctx, r, &view));

    gsf__raster_job job;
    memset(&job, 0, sizeof job);
    job.r = r;
    job.kernels = gsf__raster_kernels_of(ctx->cpu_level);
    job.view = &view;
    job.out = out;
    job.flags = r->has_depth ? GSF__WITH_DEPTH : 0;
    gsf__parallel_for(ctx, (size_t)r->tiles_x * (size_t)r->tiles_y, gsf__blend_chunk, &job);
    return GSF_OK;
}

// Gradients of the colours of `width` pixels of a row in a strip.
static inline void gsf__row_gradient(const float* d_color, int at, int width, const float background[3],
                                     gsf__tile_gradient* gradient) {
    for (int i = 0; i < width; i++) {
        const float* d = d_color + 3 * i;
        const int k = at + 2 * i;
        gradient->r[k] = d[0];
        gradient->g[k] = d[1];
        gradient->b[k] = d[2];
        gradient->behind[k] = d[0] * background[0] + d[1] * background[1] + d[2] * background[2];
    }
}

static void gsf__load_tile_gradient(const gsf__raster_job* job, const gsf__tile* tile, int columns, int rows,
                                    gsf__tile_gradient* gradient, double background[3]) {
    const gsf_rasterizer* r = job->r;
    memset(gradient, 0, sizeof *gradient);
    for (int q = 0; q < GSF__TILE / GSF__STRIP * rows; q++) {
        const int strip = q % (GSF__TILE / GSF__STRIP), row = q / (GSF__TILE / GSF__STRIP);
        const int width = gsf__strip_width(strip, columns), first = gsf__tile_pixel(GSF__STRIP * strip, row);
        const size_t pixel = (size_t)((int)tile->y0 + row) * (size_t)r->width + (size_t)((int)tile->x0 + GSF__STRIP * strip);
        if (job->d_color && width == GSF__STRIP)
            gsf__row_gradient(job->d_color + 3 * pixel, first, GSF__STRIP, job->view->background, gradient);
        else if (job->d_color)
            gsf__row_gradient(job->d_color + 3 * pixel, first, width, job->view->background, gradient);
        for (int lane = 0; lane < width && job->wants_background; lane++) {
            const float T = r->final_T[pixel + (size_t)lane];
            background[0] += (double)(T * gradient->r[first + 2 * lane]);
            background[1] += (double)(T * gradient->g[first + 2 * lane]);
            background[2] += (double)(T * gradient->b[first + 2 * lane]);
        }
        for (int lane = 0; lane < width && job->d_alpha; lane++)
            gradient->a[first + 2 * lane] = job->d_alpha[pixel + (size_t)lane];
        for (int lane = 0; lane < width && job->d_depth; lane++) { // depth = D / A
            const size_t at = pixel + (size_t)lane;
            const float weight = 1.0f - r->final_T[at];
            const int k = first + 2 * lane;
            if (!(weight > 0.0f)) continue;
            gradient->z[k] = job->d_depth[at] / weight;
            gradient->a[k] -= gradient->z[k] * (r->depth_sum[at] / weight);
        }
    }
}

static void gsf__reverse_chunk(void* arg, size_t index, int32_t worker) {
    const gsf__raster_job* job = (const gsf__raster_job*)arg;
    gsf_rasterizer* r = job->r;
    const gsf__tile tile = gsf__tile_of(r, index);
    float* slots = r->slots + GSF__SLOT_FLOATS * r->tile_begin[index];
    uint8_t* slot_used = r->slot_used + r->tile_begin[index];
    double* background = r->tile_background + 3 * index;
    gsf__worker_scratch* scratch = r->workers + worker;
    gsf__tile_gradient gradient;
    GSF__LINES float T[GSF__TILE_PIXELS];
    int columns, rows;
    memset(background, 0, 3 * sizeof(double));
    gsf__tile_extent(r, &tile, &columns, &rows);
    gsf__load_tile_gradient(job, &tile, columns, rows, &gradient, background);

    // forward over the whole list, with a checkpoint at the start of every bucket of kept steps
    gsf__open_tile(T, columns, rows);
    size_t buckets = 0, next = 0, kept = 0;
    while (next < tile.count) {
        memcpy(scratch->checkpoints + buckets * GSF__TILE_PIXELS, T, sizeof T);
        scratch->checkpoint_entry[buckets++] = (uint32_t)next;
        next = job->kernels.keep(&tile, T, next, tile.count, scratch->steps, scratch->heads, &kept);
    }
    // the last bucket's steps are still in the scratch memory; those of earlier buckets are recomputed from the
    // checkpoints
    while (buckets > 0) {
        job->kernels.reverse(&tile, scratch->steps, scratch->heads, kept, &gradient, slots, slot_used, job->flags);
        if (--buckets == 0) break;
        memcpy(T, scratch->checkpoints + (buckets - 1) * GSF__TILE_PIXELS, sizeof T);
        job->kernels.keep(&tile, T, scratch->checkpoint_entry[buckets - 1], scratch->checkpoint_entry[buckets],
                           scratch->steps, scratch->heads, &kept);
    }
}

// checkpoints: buckets of the longest list.
static gsf_result gsf__reserve_workers(gsf_context* ctx, gsf_rasterizer* r, size_t checkpoints) {
    gsf__arena* arena = &r->worker_arena;
    const int32_t count = ctx->parallel.worker_count;
    if (r->worker_count >= count && r->checkpoint_capacity >= checkpoints) return GSF_OK;
    arena->ctx = ctx;
    gsf__arena_free(arena);
    arena->failed = r->worker_count = 0;
    r->checkpoint_capacity = checkpoints + checkpoints / 4;
    r->workers = (gsf__worker_scratch*)gsf__arena_alloc(arena, (size_t)count, sizeof(gsf__worker_scratch));
    for (int i = 0; r->workers && i < count; i++) {
        gsf__worker_scratch* w = r->workers + i;
        w->steps = (gsf__step*)gsf__arena_alloc(arena, GSF__KEPT_MOST, sizeof(gsf__step));
        w->heads = (gsf__step_head*)gsf__arena_alloc(arena, GSF__KEPT_MOST, sizeof(gsf__step_head));
        w->checkpoints = (float*)gsf__arena_alloc(arena, r->checkpoint_capacity, GSF__TILE_PIXELS * sizeof(float));
        w->checkpoint_entry = (uint32_t*)gsf__arena_alloc(arena, r->checkpoint_capacity, sizeof(uint32_t));
    }
    if (arena->failed) return GSF_ERROR_OUT_OF_MEMORY;
    r->worker_count = count;
    return GSF_OK;
}

static gsf_result gsf__reserve_backward(gsf_context* ctx, gsf_rasterizer* r) {
    const size_t tiles = (size_t)r->tiles_x * (size_t)r->tiles_y;
    if (r->entry_count > r->slot_capacity || !r->slots) {
        const size_t capacity = r->entry_count + r->entry_count / 4;
        r->slot_capacity = 0;
        GSF__TRY(gsf__grow(ctx, (void**)&r->slots, capacity, GSF__SLOT_FLOATS * sizeof(float)));
        GSF__TRY(gsf__grow(ctx, (void**)&r->slot_used, capacity, 1));
        r->slot_capacity = capacity;
    }
    GSF__TRY(gsf__reserve(ctx, (void**)&r->tile_background, &r->tile_background_capacity, 0, tiles, 3 * sizeof(double)));
    size_t longest = 0;
    for (size_t t = 0; t < tiles; t++)
        if (r->tile_begin[t + 1] - r->tile_begin[t] > longest) longest = r->tile_begin[t + 1] - r->tile_begin[t];
    return gsf__reserve_workers(ctx, r, longest * GSF__STEPS / GSF__BUCKET + 2);
}

GSF_API gsf_result gsf_splat_render_backward(gsf_context* ctx, gsf_rasterizer* r, const gsf_splats* splats,
                                             const gsf_camera* camera, const gsf_render_desc* desc, const float* d_color,
                                             const float* d_depth, const float* d_alpha, const gsf_splat_grads* grads) {
    gsf_render_desc defaults;
    memset(&defaults, 0, sizeof defaults);
    if (!desc) desc = &defaults;
    GSF__TRY(gsf__check_render(ctx, splats, camera, desc));
    if (splats->count != r->splat_count || camera->width != r->width || camera->height != r->height)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render backward: splats or camera differ from the last render");
    if (d_depth && !r->has_depth)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "render backward: d_depth given, but no depth was rendered");
    GSF__TRY(gsf__reserve_backward(ctx, r));

    const gsf__view view = gsf__make_view(splats, camera, desc);
    const size_t tiles = (size_t)r->tiles_x * (size_t)r->tiles_y;
    gsf__raster_job job;
    memset(&job, 0, sizeof job);
    job.r = r;
    job.kernels = gsf__raster_kernels_of(ctx->cpu_level);
    job.view = &view;
    job.d_color = d_color;
    job.d_depth = d_depth;
    job.d_alpha = d_alpha;
    job.wants_background = grads->background != NULL;
    job.flags = (d_depth || d_alpha ? GSF__WITH_DEPTH : 0) | (view.official_gradient ? GSF__STRAIGHT_THROUGH : 0) |
                (grads->means2d_abs ? GSF__WITH_ABS : 0);
    if (r->entry_count) memset(r->slot_used, 0, r->entry_count);
    gsf__parallel_for(ctx, tiles, gsf__reverse_chunk, &job);
    if (grads->background)
        for (int c = 0; c < 3; c++) {
            double sum = 0.0;
            for (size_t t = 0; t < tiles; t++) sum += r->tile_background[3 * t + (size_t)c];
            grads->background[c] += (float)sum;
        }
    gsf__splat_loop gather = {r, &view, splats, NULL, grads, ctx->cpu_level};
    gsf__parallel_for(ctx, gsf__splat_chunks(r), gsf__gather_chunk, &gather);
    return GSF_OK;
}

// ---- >>loss --------------------------------------------------------------------
// L = (1 - lambda) mean(w |x - t|) + lambda mean(w (1 - SSIM(x, t))), where x is the render, t the photo (both clamped
// to 0..1) and w a weight per pixel. Both means are over all H*W*3 values whatever w is, so a pixel of weight 0 counts
// as already correct. Such a pixel is treated as if it were outside the image: black in both x and t, so that neither
// image affects the windows of its neighbours there. Hence its gradient is 0.
// SSIM as in the 3DGS code: 11x11 Gaussian window, sigma 1.5, zero padding, variances not clamped.
//
// A variance is a difference of squares, and SSIM compares it with C2 = 9e-4, so float is precise enough only if the
// squares are small. Therefore everything is computed from the sum and the difference of the images, s = x + t - b and
// d = x - t, and from the squares of s and d - c, where b and c are close to the medians of x + t and x - t. With the
// window sums S = G*s, D = G*d, P = G*s^2, Q = G*(d - c)^2:
//     z = S + b = mu + mu_t,  vs = P - S^2 + k z^2,  vd = Q - (D - c)^2 + k D^2
//     B1 = z^2 + D^2 + 2 C1,  B2 = vs + vd + 2 C2,  p = 2 D^2 / B1,  q = 2 vd / B2,  1 - SSIM = p + q - p q
// where p and q are small if D and d are, however bright the images are. k = 6.94e-8: the window of the 3DGS code,
// rounded to float32, sums to 1 - k, which adds k mu^2 to its variances; for bright noise this changes the mean SSIM by
// more than 1e-6.
//     e = (1 - p) / B2,  e_s = e q / 2,  e_d = e - e_s
//     a = (1 - q) (D - p mu) / B1 + (S - k z) e_s - (D - c - k D) e_d
// and the gradient at pixel i is 1/4 d(1 - SSIM)/dx(i) = G*a + (d(i) - c) G*e_d - s(i) G*e_s.
//
// Images stay interleaved: a row is 3W floats, padded to whole vectors, and horizontal taps are 3 floats apart. Rows
// are processed in groups of four, which share the loads of their vertical sums. Each worker streams a band of rows
// through two ring buffers:
//     images   s, d, s^2, (d - c)^2                         5 groups, starting at row first - 10 of the band
//     slopes   w a, w e_d, w e_s                            4 groups, starting at row first - 5
// so that images g .. g + 3 give slopes g, and slopes g .. g + 3 the gradient of rows first + 4 g .. first + 4 g + 3.
// Bands overlap: per band, 20 additional rows are loaded and 10 are mapped.

enum {
    GSF__LOSS_RADIUS = 5, GSF__LOSS_MARGIN = 16, GSF__LOSS_GROUP = 4,
    GSF__LOSS_IMAGES = 5 * GSF__LOSS_GROUP, GSF__LOSS_SLOPES = 4 * GSF__LOSS_GROUP, // rows of the rings
    GSF__LOSS_BAND = 64,                                                            // maximum rows of a band
    // per worker: rings, sums of four planes, vertical sums of one, four planes outside the image, b and c, weights,
    // render
    GSF__LOSS_WORKER_ROWS = 4 * GSF__LOSS_IMAGES + 3 * GSF__LOSS_SLOPES + (4 + 1) * GSF__LOSS_GROUP + 4 + 2 + 1 + 1
};

#define GSF__SSIM_C1 0.0001f // (0.01 * 1)^2
#define GSF__SSIM_C2 0.0009f // (0.03 * 1)^2
#define GSF__SSIM_LACK 6.94426e-8f // k: 1 minus the sum of the window of the 3DGS code

// exp(-k^2 / (2 * 1.5^2)) for k = 0..5, divided by its sum over k = -5..5
static const float gsf__loss_window[GSF__LOSS_RADIUS + 1] = {0.2660117249f,  0.2130055377f,   0.1093606895f,
                                                             0.03600077213f, 0.007598758135f, 0.001028380084f};

typedef struct gsf__target { // a photo to be matched
    int32_t width, height;
    const uint8_t* u8;       // (H,W,3) packed, or NULL
    const float* f32;        // (H,W,3) packed, used if u8 is NULL
    const float* weight;     // (H,W), NULL = 1 everywhere; where it is 0 the photo is black
} gsf__target;

typedef struct gsf__loss_scratch { // grows to fit the largest photo and is then reused
    float* rows;             // GSF__LOSS_WORKER_ROWS rows with margins per worker
    double* sums;            // 2 per band
    size_t row_capacity, sum_capacity; // floats, doubles
} gsf__loss_scratch;

typedef struct gsf__loss_value { double total, l1, ssim; } gsf__loss_value; // total is not multiplied by `scale`

// n: padded row length; valid: 3W, or 0 for rows outside the image; planes are `step` floats apart.
typedef struct gsf__loss_kernels {
    // Computes s, d, s^2 and (d - c)^2 from the render (NaN counts as 0) and the photo, both 0 from valid to n.
    void (*load)(const float* render, const float* f32, const uint8_t* u8, const float* b, const float* c, size_t valid,
                 size_t n, float* images, size_t step);
    // Vertical sums of a group of rows from four groups v; the first is centred on the sixth row of v. Rows are
    // `stride` floats apart.
    void (*down)(const float* const v[4], size_t stride, size_t n, float* sums);
    // Horizontal sums of a row that starts at a cache line and has margins.
    void (*across)(const float* v, size_t n, float* sums);
    // Computes the three slopes of the SSIM map from the window sums and adds the sums of w |d| and w/2 (1 - SSIM) to
    // totals. weight: 0 from valid to n.
    void (*map)(const float* sums, size_t sums_step, const float* d, const float* b, const float* c, const float* weight,
                size_t n, float* slopes, size_t step, double totals[2]);
    // Computes the gradient with respect to the render from the window sums of the slopes.
    void (*gradient)(const float* sums, size_t sums_step, const float* s, const float* d, const float* c,
                     const float* weight, const float* render, float l1_scale, float ssim_scale, size_t valid,
                     float* d_render);
    // Computes the sums over RGB of |t[p + i] - t[q + i]| for `count` pixels of a photo t, f32 or, if that is NULL, u8; p
    // and q are the offsets of the first pixels' values. differences: room for 3 `count`, rounded up to whole vectors.
    void (*contrast)(const float* f32, const uint8_t* u8, size_t p, size_t q, size_t count, float* differences, float* out);
    // Computes the derivative of e |a - b| with respect to a, e = 1 / (1 + (scale contrast)^2), and adds e |a - b| to the
    // sum. Pixels where a or b is negative have no depth: both are 0.
    void (*smooth)(const float* a, const float* b, const float* contrast, float scale, size_t count, float* slope,
                   double* sum);
} gsf__loss_kernels;

static float gsf__loss_clamp(float v) { return v > 0.0f ? (v < 1.0f ? v : 1.0f) : 0.0f; } // NaN: 0

#define GSF__KERNELS "gsfixer_splat.h"
#define GSF__KERNELS_LOSS
#define GSF__KERNELS_SIMD128
#define GSF__KERNELS_AVX512
#include "gsfixer.h" // compiles what follows, once per instruction set
#undef GSF__KERNELS_LOSS

#endif // GSF__ISA
#ifdef GSF__KERNELS_LOSS

GSF__V_INLINE gsf__vf GSF__V(gsf__loss_clamp)(gsf__vf v) { // NaN: 0
    return gsf__v_min(gsf__v_max(v, gsf__v_set(0.0f)), gsf__v_set(1.0f));
}

// A byte divided by 255. The fused form gives the quotient's bits for all 256, without a division.
GSF__V_INLINE gsf__vf GSF__V(gsf__loss_unit)(gsf__vf byte) {
    const float high = 1.0f / 255.0f, low = (float)(1.0 / 255.0 - (double)high);
    if (GSF__LANES < 8) return byte / gsf__v_set(255.0f); // gsf__v_madd is fused with 8 lanes and more
    return gsf__v_madd(byte, gsf__v_set(high), byte * gsf__v_set(low));
}

GSF__V_KERNEL void GSF__V(gsf__loss_load)(const float* render, const float* f32, const uint8_t* u8, const float* b,
                                          const float* c, size_t valid, size_t n, float* images, size_t step) {
    for (size_t i = 0; i < n; i += GSF__LANES) {
        const size_t left = i < valid ? valid - i : 0;
        gsf__vf x = gsf__v_set(0.0f), t = x;
        if (left) {
            x = GSF__V(gsf__loss_clamp)(gsf__v_load_first(render + i, left));
            if (u8) t = GSF__V(gsf__loss_unit)(gsf__v_load_bytes(u8 + i, left));
            else t = GSF__V(gsf__loss_clamp)(gsf__v_load_first(f32 + i, left));
        }
        const gsf__vf s = (x - gsf__v_load(b + i)) + t, d = x - t, e = d - gsf__v_load(c + i);
        gsf__v_store(images + i, s);
        gsf__v_store(images + step + i, d);
        gsf__v_store(images + 2 * step + i, s * s);
        gsf__v_store(images + 3 * step + i, e * e);
    }
}

GSF__V_INLINE gsf__vf GSF__V(gsf__loss_taps)(int k, gsf__vf a, gsf__vf b, gsf__vf sum) {
    return gsf__v_madd(gsf__v_set(gsf__loss_window[k]), a + b, sum);
}

// Loads each of the 14 rows once, from the outermost to the middle ones.
GSF__V_KERNEL void GSF__V(gsf__loss_down)(const float* const v[4], size_t stride, size_t n, float* sums) {
    const gsf__vf zero = gsf__v_set(0.0f), middle = gsf__v_set(gsf__loss_window[0]);
    const float *v0 = v[0], *v1 = v[1], *v2 = v[2], *v3 = v[3];
    for (size_t i = 0; i < n; i += GSF__LANES) {
#define GSF__LOSS_ROW(k, block) const gsf__vf r##k = gsf__v_load(block + k % GSF__LOSS_GROUP * stride + i)
#define GSF__LOSS_TAPS GSF__V(gsf__loss_taps)
        GSF__LOSS_ROW(0, v0); GSF__LOSS_ROW(1, v0); GSF__LOSS_ROW(2, v0); GSF__LOSS_ROW(3, v0);
        GSF__LOSS_ROW(10, v2); GSF__LOSS_ROW(11, v2); GSF__LOSS_ROW(12, v3); GSF__LOSS_ROW(13, v3);
        gsf__vf a = GSF__LOSS_TAPS(5, r0, r10, zero), b = GSF__LOSS_TAPS(5, r1, r11, zero);
        gsf__vf c = GSF__LOSS_TAPS(5, r2, r12, zero), d = GSF__LOSS_TAPS(5, r3, r13, zero);
        GSF__LOSS_ROW(4, v1); GSF__LOSS_ROW(9, v2);
        a = GSF__LOSS_TAPS(4, r1, r9, a), b = GSF__LOSS_TAPS(4, r2, r10, b);
        c = GSF__LOSS_TAPS(4, r3, r11, c), d = GSF__LOSS_TAPS(4, r4, r12, d);
        GSF__LOSS_ROW(5, v1); GSF__LOSS_ROW(8, v2);
        a = GSF__LOSS_TAPS(3, r2, r8, a), b = GSF__LOSS_TAPS(3, r3, r9, b);
        c = GSF__LOSS_TAPS(3, r4, r10, c), d = GSF__LOSS_TAPS(3, r5, r11, d);
        GSF__LOSS_ROW(6, v1); GSF__LOSS_ROW(7, v1);
        a = GSF__LOSS_TAPS(2, r3, r7, a), b = GSF__LOSS_TAPS(2, r4, r8, b);
        c = GSF__LOSS_TAPS(2, r5, r9, c), d = GSF__LOSS_TAPS(2, r6, r10, d);
        a = GSF__LOSS_TAPS(1, r4, r6, a), b = GSF__LOSS_TAPS(1, r5, r7, b);
        c = GSF__LOSS_TAPS(1, r6, r8, c), d = GSF__LOSS_TAPS(1, r7, r9, d);
#undef GSF__LOSS_TAPS
#undef GSF__LOSS_ROW
        gsf__v_store(sums + i, gsf__v_madd(middle, r5, a));
        gsf__v_store(sums + stride + i, gsf__v_madd(middle, r6, b));
        gsf__v_store(sums + 2 * stride + i, gsf__v_madd(middle, r7, c));
        gsf__v_store(sums + 3 * stride + i, gsf__v_madd(middle, r8, d));
    }
}

GSF__V_KERNEL void GSF__V(gsf__loss_map)(const float* sums, size_t sums_step, const float* d, const float* b, const float* c,
                                         const float* weight, size_t n, float* slopes, size_t step, double totals[2]) {
    const gsf__vf c1 = gsf__v_set(2.0f * GSF__SSIM_C1), c2 = gsf__v_set(2.0f * GSF__SSIM_C2);
    const gsf__vf one = gsf__v_set(1.0f), lack = gsf__v_set(GSF__SSIM_LACK), zero = gsf__v_set(0.0f);
    gsf__vd l1 = gsf__vd_set(0.0), dssim = l1;
    gsf__vf l1_part = zero, dssim_part = zero;
    for (size_t i = 0; i < n; i += GSF__LANES) {
        const gsf__vf S = gsf__v_load(sums + i), D = gsf__v_load(sums + sums_step + i);
        const gsf__vf P = gsf__v_load(sums + 2 * sums_step + i), Q = gsf__v_load(sums + 3 * sums_step + i);
        const gsf__vf z = S + gsf__v_load(b + i), Dc = D - gsf__v_load(c + i), w = gsf__v_load(weight + i);
        const gsf__vf zz = gsf__v_madd(z, z, c1), DD = D * D, B1 = zz + DD;
        const gsf__vf vs = gsf__v_nmadd(S, S, P), vd = gsf__v_madd(lack, DD, gsf__v_nmadd(Dc, Dc, Q));
        const gsf__vf B2 = (vs + vd) + gsf__v_madd(lack, zz, c2); // zz includes c1; lack * c1 is negligible
        const gsf__vf r = one / (B1 * B2), r1 = B2 * r, r2 = B1 * r, p = DD * r1, q = vd * r2; // halves of p and q
        const gsf__vf like = one - (p + p), con = one - (q + q);
        const gsf__vf e = w * (like * r2), es = e * q, ed = e - es;
        gsf__vf a = (w * (con * r1)) * gsf__v_nmadd(p, z + D, D);
        a = gsf__v_madd(gsf__v_nmadd(lack, z, S), es, a);
        gsf__v_store(slopes + i, gsf__v_nmadd(gsf__v_nmadd(lack, D, Dc), ed, a));
        gsf__v_store(slopes + step + i, ed);
        gsf__v_store(slopes + 2 * step + i, es);
        l1_part = gsf__v_madd(w, gsf__v_abs(gsf__v_load(d + i)), l1_part);
        dssim_part = gsf__v_madd(w, gsf__v_madd(q, like, p), dssim_part);
        if (GSF__LANES > 1 && i / GSF__LANES % 8 != 7 && i + GSF__LANES < n) continue; // sum 8 vectors in float
        l1 = gsf__vd_add_folded(l1, l1_part);
        dssim = gsf__vd_add_folded(dssim, dssim_part);
        l1_part = dssim_part = zero;
    }
    totals[0] += gsf__vd_sum(l1);
    totals[1] += gsf__vd_sum(dssim);
}

GSF__V_KERNEL void GSF__V(gsf__loss_gradient)(const float* sums, size_t sums_step, const float* s, const float* d,
                                              const float* c, const float* weight, const float* render, float l1_scale,
                                              float ssim_scale, size_t valid, float* d_render) {
    const gsf__vf zero = gsf__v_set(0.0f), one = gsf__v_set(1.0f);
    const gsf__vf l1 = gsf__v_set(l1_scale), ssim = gsf__v_set(4.0f * ssim_scale);
    for (size_t i = 0; i < valid; i += GSF__LANES) {
        const gsf__vf diff = gsf__v_load(d + i), e = diff - gsf__v_load(c + i);
        gsf__vf quarter = gsf__v_madd(e, gsf__v_load(sums + sums_step + i), gsf__v_load(sums + i));
        quarter = gsf__v_nmadd(gsf__v_load(s + i), gsf__v_load(sums + 2 * sums_step + i), quarter);
        const gsf__vf l1_slope = gsf__v_with_sign(l1 * gsf__v_load(weight + i), diff);
        const gsf__vf slope = gsf__v_madd(ssim, quarter, gsf__v_keep(gsf__vm_not(gsf__v_eq(diff, zero)), l1_slope));
        const gsf__vf r = gsf__v_load_first(render + i, valid - i); // no gradient where r was clamped or is NaN
        const gsf__vm inside = gsf__vm_and(gsf__v_ge(r, zero), gsf__v_le(r, one));
        gsf__v_store_first(d_render + i, gsf__v_keep(inside, slope), valid - i);
    }
}

GSF__V_KERNEL void GSF__V(gsf__loss_contrast)(const float* f32, const uint8_t* u8, size_t p, size_t q, size_t count,
                                              float* differences, float* out) {
    for (size_t i = 0; i < 3 * count; i += GSF__LANES) {
        const size_t left = 3 * count - i;
        const gsf__vf a = u8 ? gsf__v_load_bytes(u8 + p + i, left) : gsf__v_load_first(f32 + p + i, left);
        const gsf__vf b = u8 ? gsf__v_load_bytes(u8 + q + i, left) : gsf__v_load_first(f32 + q + i, left);
        gsf__v_store(differences + i, gsf__v_abs(a - b));
    }
    for (size_t x = 0; x < count; x += GSF__LANES) {
        const gsf__vi pixel = gsf__vi_min(gsf__vi_index(), gsf__vi_set((int32_t)(count - 1 - x)));
        const gsf__vi at = gsf__vi_mul(pixel, gsf__vi_set(3));
        const float* d = differences + 3 * x;
        const gsf__vf sum = (gsf__v_gather(d, at) + gsf__v_gather(d + 1, at)) + gsf__v_gather(d + 2, at);
        gsf__v_store_first(out + x, sum, count - x);
    }
}

GSF__V_KERNEL void GSF__V(gsf__loss_smooth)(const float* a, const float* b, const float* contrast, float scale,
                                            size_t count, float* slope, double* sum) {
    const gsf__vf zero = gsf__v_set(0.0f), one = gsf__v_set(1.0f), by = gsf__v_set(scale);
    gsf__vd total = gsf__vd_set(0.0);
    for (size_t i = 0; i < count; i += GSF__LANES) {
        const size_t left = count - i;
        const gsf__vf p = gsf__v_load_first(a + i, left), q = gsf__v_load_first(b + i, left), difference = p - q;
        const gsf__vf d = by * gsf__v_load_first(contrast + i, left), edge = one / (one + d * d);
        gsf__vm counts = gsf__vm_and(gsf__v_ge(p, zero), gsf__v_ge(q, zero));
        counts = gsf__vm_and(counts, gsf__vm_not(gsf__v_eq(difference, zero)));
        gsf__v_store_first(slope + i, gsf__v_keep(counts, gsf__v_with_sign(edge, difference)), left);
        total = gsf__vd_add_folded(total, gsf__v_keep(counts, edge * gsf__v_abs(difference)));
    }
    *sum += gsf__vd_sum(total);
}

#endif // GSF__KERNELS_LOSS
#ifndef GSF__ISA

static void gsf__loss_across_scalar(const float* v, size_t n, float* sums) {
    for (size_t i = 0; i < n; i++, v++) {
        sums[i] = gsf__loss_window[0] * v[0];
        for (int k = 1; k <= GSF__LOSS_RADIUS; k++) sums[i] += gsf__loss_window[k] * (v[-3 * k] + v[3 * k]);
    }
}

#if GSF__X86
// Eight consecutive floats that start `by` (1..3) floats after those of `low`; `high` starts 4 floats after `low`.
#define GSF__LOSS_BETWEEN(low, high, by) _mm256_castsi256_ps(_mm256_alignr_epi8(high, low, 4 * (by)))

// About half of all unaligned loads cross a cache line. So the outer taps are assembled from aligned loads, and values
// that are needed again stay in registers: m16 .. p16 hold the eight floats that start at i - 16 .. i + 16.
GSF__TARGET_AVX2 static void gsf__loss_across_avx2(const float* v, size_t n, float* sums) {
    const __m256 middle = _mm256_set1_ps(gsf__loss_window[0]);
#define GSF__LOSS_EIGHT(at) _mm256_loadu_si256((const __m256i*)(const void*)(at))
    __m256i m16 = GSF__LOSS_EIGHT(v - 16), m12 = GSF__LOSS_EIGHT(v - 12), m8 = GSF__LOSS_EIGHT(v - 8);
    __m256i m4 = GSF__LOSS_EIGHT(v - 4), p0 = GSF__LOSS_EIGHT(v), p4 = GSF__LOSS_EIGHT(v + 4), p8 = GSF__LOSS_EIGHT(v + 8);
    for (size_t i = 0; i < n; i += 8) {
        const __m256i p16 = GSF__LOSS_EIGHT(v + i + 16), p12 = _mm256_permute2x128_si256(p8, p16, 0x21);
        __m256 s = _mm256_mul_ps(middle, _mm256_castsi256_ps(p0));
        s = gsf__loss_taps_avx2(1, _mm256_loadu_ps(v + i - 3), _mm256_loadu_ps(v + i + 3), s);
        s = gsf__loss_taps_avx2(2, _mm256_loadu_ps(v + i - 6), _mm256_loadu_ps(v + i + 6), s);
        s = gsf__loss_taps_avx2(3, GSF__LOSS_BETWEEN(m12, m8, 3), GSF__LOSS_BETWEEN(p8, p12, 1), s);
        s = gsf__loss_taps_avx2(4, _mm256_castsi256_ps(m12), _mm256_castsi256_ps(p12), s);
        s = gsf__loss_taps_avx2(5, GSF__LOSS_BETWEEN(m16, m12, 1), GSF__LOSS_BETWEEN(p12, p16, 3), s);
        _mm256_storeu_ps(sums + i, s);
        m16 = m8, m8 = p0, p0 = p8, p8 = p16;
        m12 = m4, m4 = p4, p4 = p12;
    }
#undef GSF__LOSS_EIGHT
}
#undef GSF__LOSS_BETWEEN

// Sixteen consecutive floats that start `by` (1..15) floats after those of `low`; `high` starts 16 floats after `low`.
#define GSF__LOSS_BETWEEN(low, high, by) _mm512_castsi512_ps(_mm512_alignr_epi32(high, low, by))

GSF__TARGET_AVX512 static void gsf__loss_across_avx512(const float* v, size_t n, float* sums) {
    const __m512 middle = _mm512_set1_ps(gsf__loss_window[0]);
    __m512i m16 = _mm512_loadu_si512(v - 16), p0 = _mm512_loadu_si512(v);
    for (size_t i = 0; i < n; i += 16) {
        const __m512i p16 = _mm512_loadu_si512(v + i + 16);
        __m512 s = _mm512_mul_ps(middle, _mm512_castsi512_ps(p0));
        s = gsf__loss_taps_avx512(1, GSF__LOSS_BETWEEN(m16, p0, 13), GSF__LOSS_BETWEEN(p0, p16, 3), s);
        s = gsf__loss_taps_avx512(2, GSF__LOSS_BETWEEN(m16, p0, 10), GSF__LOSS_BETWEEN(p0, p16, 6), s);
        s = gsf__loss_taps_avx512(3, GSF__LOSS_BETWEEN(m16, p0, 7), GSF__LOSS_BETWEEN(p0, p16, 9), s);
        s = gsf__loss_taps_avx512(4, GSF__LOSS_BETWEEN(m16, p0, 4), GSF__LOSS_BETWEEN(p0, p16, 12), s);
        s = gsf__loss_taps_avx512(5, GSF__LOSS_BETWEEN(m16, p0, 1), GSF__LOSS_BETWEEN(p0, p16, 15), s);
        _mm512_storeu_ps(sums + i, s);
        m16 = p0, p0 = p16;
    }
}
#undef GSF__LOSS_BETWEEN

#elif GSF__SIMD128
static void gsf__loss_across_simd128(const float* v, size_t n, float* sums) {
    const gsf__vf_simd128 middle = gsf__v_set_simd128(gsf__loss_window[0]);
    for (size_t i = 0; i < n; i += 4, v += 4) {
        gsf__vf_simd128 s = middle * gsf__v_load_simd128(v);
        for (int k = 1; k <= GSF__LOSS_RADIUS; k++)
            s = gsf__loss_taps_simd128(k, gsf__v_load_simd128(v - 3 * k), gsf__v_load_simd128(v + 3 * k), s);
        gsf__v_store_simd128(sums + i, s);
    }
}
#endif

static gsf__loss_kernels gsf__loss_kernels_of(gsf_cpu_level level) {
    const gsf__loss_kernels kernels = {GSF__ANY_KERNEL_OF(level, gsf__loss_load), GSF__ANY_KERNEL_OF(level, gsf__loss_down),
                                       GSF__ANY_KERNEL_OF(level, gsf__loss_across), GSF__ANY_KERNEL_OF(level, gsf__loss_map),
                                       GSF__ANY_KERNEL_OF(level, gsf__loss_gradient),
                                       GSF__ANY_KERNEL_OF(level, gsf__loss_contrast),
                                       GSF__ANY_KERNEL_OF(level, gsf__loss_smooth)};
    return kernels;
}

typedef struct gsf__loss_job {
    gsf__loss_kernels k;
    const gsf__target* target;
    const float* render;
    float* rows;
    double* sums;
    float* d_render;
    float l1_scale, ssim_scale;
    size_t valid, n, row; // floats of a row: in the image, padded, with margins
} gsf__loss_job;

typedef struct gsf__loss_buffers { // of a worker processing a band; pointers are to column 0 of row 0
    float *images, *slopes, *sums, *vertical, *weight; // vertical: vertical sums of one plane
    float *middle[2], *outside, *render;               // middle: b and c; outside: planes of `images` outside it
    int32_t first, end;                                // rows of the band
} gsf__loss_buffers;

// Floats of a row, rounded up to whole vectors.
static size_t gsf__loss_padded(gsf_cpu_level level, int32_t width) {
    const size_t lanes = level >= GSF_CPU_AVX512 ? 16 : 8;
    return (3 * (size_t)width + lanes - 1) & ~(lanes - 1);
}

// Floats of a row with its margins: an odd number of cache lines, so that rows do not compete for the same cache sets.
static size_t gsf__loss_row(int32_t width) {
    return ((3 * (size_t)width + 2 * GSF__LOSS_MARGIN + 15) & ~(size_t)15) | 16;
}

// Rows per band: at most GSF__LOSS_BAND, chosen to give bands of about equal height.
static int32_t gsf__loss_band_rows(int32_t height) {
    const int32_t bands = (height - 1) / GSF__LOSS_BAND + 1;
    return (height - 1) / bands + 1;
}

static size_t gsf__loss_band_count(int32_t height) { return (size_t)((height - 1) / gsf__loss_band_rows(height)) + 1; }

// The weights of row y, one for each float. Without weights returns `out` as it is: ones.
static const float* gsf__loss_weights(const gsf__loss_job* job, int32_t y, float* out) {
    const size_t width = (size_t)job->target->width;
    if (!job->target->weight) return out;
    const float* weight = job->target->weight + (size_t)y * width;
    for (size_t i = 0; i < width; i++) out[3 * i] = out[3 * i + 1] = out[3 * i + 2] = weight[i];
    return out;
}

// Row y of the render, with NaN where the weight is 0: the kernels treat NaN as black and give it no gradient.
static const float* gsf__loss_render(const gsf__loss_job* job, int32_t y, float* out) {
    const size_t width = (size_t)job->target->width;
    const float* render = job->render + (size_t)y * job->valid;
    if (!job->target->weight) return render;
    const float* weight = job->target->weight + (size_t)y * width;
    for (size_t i = 0; i < width; i++)
        for (size_t k = 0; k < 3; k++) out[3 * i + k] = weight[i] > 0.0f ? render[3 * i + k] : NAN;
    return out;
}

// Fills in b and c for each float of a row and its margins: per channel, the medians over a grid of the band's pixels.
// Any values give a correct result; medians make s and d - c vanish for flat images or backgrounds. In an image that is
// no larger than the window's radius, every window reaches beyond the border and zeros serve as well.
static void gsf__loss_fill_middle(const gsf__loss_job* job, const gsf__loss_buffers* b) {
    enum { GRID = 4 };
    const gsf__target* target = job->target;
    const size_t margin = GSF__LOSS_MARGIN, across = (size_t)(target->width - 1) / GRID + 1;
    const int32_t down = (b->end - b->first - 1) / GRID + 1;
    float sorted[6][GRID * GRID];
    size_t count = 0;
    for (int32_t y = b->first; y < b->end; y += down)
        for (size_t x = 0; x < (size_t)target->width; x += across) {
            if (target->weight && !(target->weight[(size_t)y * (size_t)target->width + x] > 0.0f)) continue;
            for (size_t k = 0; k < 3; k++) {
                const size_t at = (size_t)y * job->valid + 3 * x + k;
                const float r = gsf__loss_clamp(job->render[at]);
                const float t = target->u8 ? (float)target->u8[at] / 255.0f : gsf__loss_clamp(target->f32[at]);
                for (size_t p = 0; p < 2; p++) {
                    const float value = p ? r - t : r + t;
                    float* list = sorted[3 * p + k];
                    size_t to = count;
                    for (; to > 0 && list[to - 1] > value; to--) list[to] = list[to - 1];
                    list[to] = value;
                }
            }
            count++;
        }
    const int wide = count > 0 && target->width > GSF__LOSS_RADIUS && target->height > GSF__LOSS_RADIUS;
    for (size_t p = 0; p < 2; p++) {
        float* row = b->middle[p] - margin; // starts with channel 2, as the margin is 16 floats and a pixel 3
        for (size_t i = 0; i < 3; i++) row[i] = wide ? sorted[3 * p + (i + 2) % 3][count / 2] : 0.0f;
        for (size_t i = 3; i < job->n + 2 * margin; i++) row[i] = row[i - 3];
    }
    job->k.load(NULL, NULL, NULL, b->middle[0] - margin, b->middle[1] - margin, 0, job->n + 2 * margin, b->outside - margin,
                job->row);
}

// Window sums of the four rows in the middle of groups g .. g + 3 of a ring. outside: values of the planes outside the
// image, NULL = zeros.
static void gsf__loss_blur(const gsf__loss_job* job, const gsf__loss_buffers* b, const float* ring, size_t ring_rows,
                           size_t g, size_t planes, const float* outside) {
    const size_t margin = GSF__LOSS_MARGIN * sizeof(float);
    for (size_t p = 0; p < planes; p++) {
        const float* v[4];
        for (size_t k = 0; k < 4; k++) v[k] = ring + (p * ring_rows + (g + k) * GSF__LOSS_GROUP % ring_rows) * job->row;
        job->k.down(v, job->row, job->n, b->vertical);
        for (size_t j = 0; j < GSF__LOSS_GROUP; j++) {
            float* sums = b->vertical + j * job->row;
            if (outside) {
                memcpy(sums - GSF__LOSS_MARGIN, outside + p * job->row - GSF__LOSS_MARGIN, margin);
                memcpy(sums + job->n, outside + p * job->row + job->n, margin);
            } else {
                memset(sums - GSF__LOSS_MARGIN, 0, margin);
                memset(sums + job->n, 0, margin);
            }
            job->k.across(sums, job->n, b->sums + (p * GSF__LOSS_GROUP + j) * job->row);
        }
    }
}

// Loads group g of the images.
static void gsf__loss_load_group(const gsf__loss_job* job, const gsf__loss_buffers* b, int32_t g) {
    const gsf__target* target = job->target;
    for (int32_t at = g * GSF__LOSS_GROUP; at < (g + 1) * GSF__LOSS_GROUP; at++) {
        const int32_t y = b->first - 2 * GSF__LOSS_RADIUS + at;
        const int inside = y >= 0 && y < target->height;
        const size_t from = inside ? (size_t)y * job->valid : 0;
        job->k.load(inside ? gsf__loss_render(job, y, b->render) : NULL, target->f32 ? target->f32 + from : NULL,
                    target->u8 ? target->u8 + from : NULL, b->middle[0], b->middle[1], inside ? job->valid : 0, job->n,
                    b->images + (size_t)(at % GSF__LOSS_IMAGES) * job->row, GSF__LOSS_IMAGES * job->row);
    }
}

// Computes group g of the slopes, zeros outside the image. Only rows of the band itself are added to `totals`.
static void gsf__loss_map_group(const gsf__loss_job* job, const gsf__loss_buffers* b, int32_t g, double* totals) {
    gsf__loss_blur(job, b, b->images, GSF__LOSS_IMAGES, (size_t)g, 4, b->outside);
    for (int32_t at = g * GSF__LOSS_GROUP; at < (g + 1) * GSF__LOSS_GROUP; at++) {
        const int32_t y = b->first - GSF__LOSS_RADIUS + at;
        const float* sums = b->sums + (size_t)(at % GSF__LOSS_GROUP) * job->row;
        const float* s = b->images + (size_t)((at + GSF__LOSS_RADIUS) % GSF__LOSS_IMAGES) * job->row;
        float* slopes = b->slopes + (size_t)(at % GSF__LOSS_SLOPES) * job->row;
        double other[2] = {0.0, 0.0};
        if (y >= 0 && y < job->target->height)
            job->k.map(sums, GSF__LOSS_GROUP * job->row, s + GSF__LOSS_IMAGES * job->row, b->middle[0], b->middle[1],
                       gsf__loss_weights(job, y, b->weight), job->n, slopes, GSF__LOSS_SLOPES * job->row,
                       y >= b->first && y < b->end ? totals : other);
        else
            for (size_t p = 0; p < 3; p++) memset(slopes + p * GSF__LOSS_SLOPES * job->row, 0, job->n * sizeof(float));
    }
}

// Computes the gradient of group g of the band's rows.
static void gsf__loss_gradient_group(const gsf__loss_job* job, const gsf__loss_buffers* b, int32_t g) {
    gsf__loss_blur(job, b, b->slopes, GSF__LOSS_SLOPES, (size_t)g, 3, NULL);
    for (int32_t at = g * GSF__LOSS_GROUP; at < (g + 1) * GSF__LOSS_GROUP && b->first + at < b->end; at++) {
        const size_t packed = (size_t)(b->first + at) * job->valid;
        const float* s = b->images + (size_t)((at + 2 * GSF__LOSS_RADIUS) % GSF__LOSS_IMAGES) * job->row;
        job->k.gradient(b->sums + (size_t)(at % GSF__LOSS_GROUP) * job->row, GSF__LOSS_GROUP * job->row, s,
                        s + GSF__LOSS_IMAGES * job->row, b->middle[1], gsf__loss_weights(job, b->first + at, b->weight),
                        gsf__loss_render(job, b->first + at, b->render), job->l1_scale, job->ssim_scale, job->valid,
                        job->d_render + packed);
    }
}

// The rows of a band, and the worker's buffers. row: floats from one row of the scratch to the next.
static gsf__loss_buffers gsf__loss_buffers_of(float* scratch, size_t row, int32_t height, size_t band, int32_t worker) {
    const int32_t rows = gsf__loss_band_rows(height);
    gsf__loss_buffers b;
    b.first = (int32_t)band * rows;
    b.end = height - b.first > rows ? b.first + rows : height;
    b.images = scratch + (size_t)worker * GSF__LOSS_WORKER_ROWS * row + GSF__LOSS_MARGIN;
    b.slopes = b.images + 4 * GSF__LOSS_IMAGES * row;
    b.sums = b.slopes + 3 * GSF__LOSS_SLOPES * row;
    b.vertical = b.sums + 4 * GSF__LOSS_GROUP * row;
    b.outside = b.vertical + GSF__LOSS_GROUP * row;
    b.middle[0] = b.outside + 4 * row;
    b.middle[1] = b.middle[0] + row;
    b.weight = b.middle[1] + row;
    b.render = b.weight + row;
    return b;
}

static void gsf__loss_band(void* arg, size_t band, int32_t worker) {
    const gsf__loss_job* job = (const gsf__loss_job*)arg;
    gsf__loss_buffers b = gsf__loss_buffers_of(job->rows, job->row, job->target->height, band, worker);
    for (size_t i = 0; i < job->n; i++) b.weight[i] = i < job->valid ? 1.0f : 0.0f;
    gsf__loss_fill_middle(job, &b);
    double* totals = job->sums + 2 * band;
    totals[0] = totals[1] = 0.0;
    for (int32_t g = 0; g < 3; g++) gsf__loss_load_group(job, &b, g);
    for (int32_t g = 0; b.first + (g - 3) * GSF__LOSS_GROUP < b.end; g++) {
        gsf__loss_load_group(job, &b, g + 3);
        gsf__loss_map_group(job, &b, g, totals);
        if (g >= 3) gsf__loss_gradient_group(job, &b, g - 3);
    }
}

static gsf_result gsf__loss_reserve(gsf_context* ctx, gsf__loss_scratch* scratch, int32_t width, int32_t height) {
    size_t floats;
    if (!gsf__mul_size((size_t)ctx->parallel.worker_count * GSF__LOSS_WORKER_ROWS, gsf__loss_row(width), &floats))
        return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "loss: image of %d x %d is too large", (int)width, (int)height);
    GSF__TRY(gsf__reserve(ctx, (void**)&scratch->rows, &scratch->row_capacity, 0, floats, sizeof(float)));
    return gsf__reserve(ctx, (void**)&scratch->sums, &scratch->sum_capacity, 0, 2 * gsf__loss_band_count(height),
                        sizeof(double));
}

static void gsf__loss_destroy_scratch(gsf_context* ctx, gsf__loss_scratch* scratch) {
    gsf_free(ctx, scratch->rows);
    gsf_free(ctx, scratch->sums);
    memset(scratch, 0, sizeof *scratch);
}

// Computes the loss of `render` (H,W,3) against the target and writes its gradient times `scale` to d_render (H,W,3).
// lambda: weight of the SSIM term.
static gsf_result gsf__loss(gsf_context* ctx, gsf__loss_scratch* scratch, const gsf__target* target, const float* render,
                            float lambda, float scale, float* d_render, gsf__loss_value* out) {
    GSF__TRY(gsf__loss_reserve(ctx, scratch, target->width, target->height));
    gsf__loss_job job;
    job.k = gsf__loss_kernels_of(ctx->cpu_level);
    job.target = target;
    job.render = render;
    job.rows = scratch->rows;
    job.sums = scratch->sums;
    job.d_render = d_render;
    job.valid = 3 * (size_t)target->width;
    job.n = gsf__loss_padded(ctx->cpu_level, target->width);
    job.row = gsf__loss_row(target->width);
    const double n = 3.0 * (double)target->width * (double)target->height;
    job.l1_scale = (float)((double)scale * (1.0 - (double)lambda) / n);
    job.ssim_scale = (float)((double)scale * (double)lambda / n);
    const size_t bands = gsf__loss_band_count(target->height);
    gsf__parallel_for(ctx, bands, gsf__loss_band, &job);
    double l1 = 0.0, dssim = 0.0;
    for (size_t i = 0; i < bands; i++) {
        l1 += scratch->sums[2 * i];
        dssim += scratch->sums[2 * i + 1];
    }
    out->l1 = l1 / n;
    dssim *= 2.0 / n; // the kernels sum (1 - SSIM) / 2
    out->ssim = 1.0 - dssim;
    out->total = (1.0 - (double)lambda) * out->l1 + (double)lambda * dssim;
    return GSF_OK;
}

// Edge-aware smoothness of inverse depth: weight / (H W) times the sum over pairs of neighbours p, q (q to the right of
// or below p) of e_pq |D_p - D_q| with D = extent / depth and e_pq = 1 / (1 + (|t_p - t_q| / 0.1)^2), where |.| is the
// mean over RGB. Pairs in which a pixel has no depth are left out. Writes the gradient to d_depth (H,W). `scratch` must
// be as gsf__loss left it for this photo.
typedef struct gsf__smooth_job {
    gsf__loss_kernels k;
    const gsf__target* target;
    const float* depth;
    float* d_depth;
    gsf__loss_scratch* scratch;
    float extent, factor;
} gsf__smooth_job;

static void gsf__smooth_row(const gsf__smooth_job* job, int32_t y, float* nearness) {
    const size_t width = (size_t)job->target->width, at = (size_t)y * width;
    for (size_t x = 0; x < width; x++) {
        const float z = y < job->target->height ? job->depth[at + x] : 0.0f;
        nearness[x] = z > 0.0f ? job->extent / z : -1.0f;
    }
}

// Slopes of `count` pairs of pixels, from p and q of the photo on; of_p and of_q are their nearness, D.
static void gsf__smooth_pairs(const gsf__smooth_job* job, const gsf__loss_buffers* b, size_t p, size_t q, size_t count,
                              const float* of_p, const float* of_q, float* slope, double* sum) {
    const gsf__target* t = job->target;
    const float scale = (t->f32 ? 1.0f : 1.0f / 255.0f) * (10.0f / 3.0f);
    float* contrast = b->outside;
    if (count == 0) return;
    job->k.contrast(t->f32, t->u8, 3 * p, 3 * q, count, b->render, contrast);
    job->k.smooth(of_p, of_q, contrast, scale, count, slope, sum);
}

// Each pair is computed once: the derivative with respect to the one pixel is minus that with respect to the other.
static void gsf__smooth_band(void* arg, size_t band, int32_t worker) {
    const gsf__smooth_job* job = (const gsf__smooth_job*)arg;
    const size_t width = (size_t)job->target->width, row = gsf__loss_row(job->target->width);
    const gsf__loss_buffers b = gsf__loss_buffers_of(job->scratch->rows, row, job->target->height, band, worker);
    float *here = b.weight, *below = here + width, *right = below + width; // right: slopes of pairs in the row
    float *up = b.middle[0], *down = b.middle[1];                          // slopes of those with the rows above and below
    double sum = 0.0, of_band_above = 0.0;
    int32_t y = b.first > 0 ? b.first - 1 : 0; // pairs with the band above belong to that band's sum
    gsf__smooth_row(job, y, here);
    memset(up, 0, width * sizeof *up);
    memset(down, 0, width * sizeof *down);
    right[width - 1] = 0.0f;
    for (; y < b.end; y++) {
        const size_t at = (size_t)y * width;
        double* to = y < b.first ? &of_band_above : &sum;
        gsf__smooth_row(job, y + 1, below);
        gsf__smooth_pairs(job, &b, at, at + 1, width - 1, here, here + 1, right, to);
        if (y + 1 < job->target->height) gsf__smooth_pairs(job, &b, at, at + width, width, here, below, down, to);
        else memset(down, 0, width * sizeof *down);
        for (size_t x = 0; x < width && y >= b.first; x++) { // dD/dz = -extent / z^2
            const float left = x > 0 ? right[x - 1] : 0.0f, z = job->depth[at + x];
            job->d_depth[at + x] = z > 0.0f ? -job->factor * (right[x] + down[x] - left - up[x]) * here[x] / z : 0.0f;
        }
        float *const next = here, *const above = up;
        here = below;
        below = next;
        up = down;
        down = above;
    }
    job->scratch->sums[band] = sum;
}

static double gsf__depth_smoothness(gsf_context* ctx, gsf__loss_scratch* scratch, const gsf__target* target,
                                    const float* depth, float extent, float weight, float* d_depth) {
    gsf__smooth_job job;
    job.k = gsf__loss_kernels_of(ctx->cpu_level);
    job.target = target;
    job.depth = depth;
    job.d_depth = d_depth;
    job.scratch = scratch;
    job.extent = extent;
    job.factor = (float)((double)weight / ((double)target->width * (double)target->height));
    const size_t bands = gsf__loss_band_count(target->height);
    gsf__parallel_for(ctx, bands, gsf__smooth_band, &job);
    double sum = 0.0;
    for (size_t i = 0; i < bands; i++) sum += scratch->sums[i];
    return sum * (double)job.factor;
}

// ---- >>adam --------------------------------------------------------------------
// The trained parameters and the Adam optimizer (Kingma & Ba 2015; betas 0.9 and 0.999, eps 1e-15 as in the Inria 3DGS
// code). Splats that are not visible in a step still move by their momentum, as they do there. A single pass reads
// parameters, moments and gradients, writes parameters and moments, and zeroes the gradients for the next step.
//
// Updates of the SH coefficients (48 of 59 parameters) can be lazy: a block of splats skips them while none of its
// splats is drawn. Once one is drawn again, or the block has skipped GSF__REST_MOST steps, or all SH are needed, the
// block makes up for the skipped steps, whose gradients were zero, in closed form. All other parameters are updated in
// every step, because they decide which splats are drawn. The unit is a block because updating scattered rows costs as
// much memory traffic as updating all of them.
//
// Memory per splat of SH degree 3: 59 parameters x (value, first and second moment, gradient) + 40 bytes = 984 bytes.

enum { GSF__MEANS = 0, GSF__SCALES, GSF__QUATS, GSF__OPACITY, GSF__SH, GSF__GROUPS };
enum { GSF__MODEL_CHUNK = 512 }; // splats per unit of parallel work
enum {
    GSF__BLOCK = 32,       // splats per block; divides the chunk sizes used here and in the projection
    GSF__REST_MOST = 254,  // a block catches up after skipping this many steps
    GSF__AWAKE = 255,      // value of gsf__model.rest: the block is up to date and drawn in this step
};

typedef struct gsf__group { // one parameter tensor of shape (count, width)
    size_t width;
    float *value, *m, *v, *grad;
} gsf__group;

typedef struct gsf__model {
    size_t count, capacity;  // capacity is a multiple of 64
    int32_t sh_degree;
    gsf__group groups[GSF__GROUPS];
    uint32_t* ids;
    // Densification statistics, the next four: [0] of photos, [1] of restored views.
    float* grad_sum[2];      // sum of screen-space gradient norms
    uint32_t* visits[2];     // number of renders in that sum: those in which the splat was visible
    float* screen[2];        // (count,2) gradient with respect to the projected mean in this step's render
    uint8_t* seen[2];        // visible in this step's render?
    uint8_t* hidden;         // excluded from this render by dropout
    uint8_t* rest;           // per block: Adam steps that its SH have skipped, or GSF__AWAKE
    struct gsf__lazy* lazy;  // how to catch up to the last step; NULL: SH are updated in every step
    uint8_t* action;         // gsf__densify_action
    uint32_t* rejected;      // per chunk: non-finite gradients and updates discarded in this step
    void* block;             // the allocation that holds all arrays above
    uint32_t next_id;
} gsf__model;

static size_t gsf__model_chunks(size_t count) { return (count + GSF__MODEL_CHUNK - 1) / GSF__MODEL_CHUNK; }

static size_t gsf__model_blocks(size_t count) { return (count + GSF__BLOCK - 1) / GSF__BLOCK; }

static size_t gsf__model_chunk_end(size_t count, size_t chunk) {
    const size_t end = (chunk + 1) * GSF__MODEL_CHUNK;
    return end < count ? end : count;
}

// Lays out the arrays of a model of `capacity` splats in `block`, each 64-byte aligned relative to it. Returns the
// number of bytes needed. If block is NULL, only computes that number.
static size_t gsf__model_layout(gsf__model* model, size_t capacity, char* block) {
    const size_t widths[GSF__GROUPS] = {3, 3, 4, 1, 3 * (size_t)gsf_splat_count_sh(model->sh_degree)};
    size_t at = 0;
#define GSF__PLACE(pointer, type, count)                            \
    do {                                                            \
        if (block) (pointer) = (type*)(void*)(block + at);          \
        at += ((count) * sizeof(type) + 63) & ~(size_t)63;          \
    } while (0)
    for (int g = 0; g < GSF__GROUPS; g++) {
        gsf__group* group = &model->groups[g];
        group->width = widths[g];
        GSF__PLACE(group->value, float, capacity * widths[g]);
        GSF__PLACE(group->m, float, capacity * widths[g]);
        GSF__PLACE(group->v, float, capacity * widths[g]);
        GSF__PLACE(group->grad, float, capacity * widths[g]);
    }
    GSF__PLACE(model->ids, uint32_t, capacity);
    for (int i = 0; i < 2; i++) GSF__PLACE(model->grad_sum[i], float, capacity);
    for (int i = 0; i < 2; i++) GSF__PLACE(model->visits[i], uint32_t, capacity);
    for (int i = 0; i < 2; i++) GSF__PLACE(model->screen[i], float, 2 * capacity);
    for (int i = 0; i < 2; i++) GSF__PLACE(model->seen[i], uint8_t, capacity);
    GSF__PLACE(model->hidden, uint8_t, capacity);
    GSF__PLACE(model->rest, uint8_t, gsf__model_blocks(capacity));
    GSF__PLACE(model->action, uint8_t, capacity);
    GSF__PLACE(model->rejected, uint32_t, gsf__model_chunks(capacity));
#undef GSF__PLACE
    return at;
}

enum { // ranges of the model's columns
    GSF__MOMENT_COLUMNS = GSF__GROUPS,                    // after the values of all groups
    GSF__ID_COLUMN = 3 * GSF__GROUPS,                     // after first and second moments
    GSF__SAVED_COLUMNS = GSF__ID_COLUMN + 5,              // with the statistics: all that a checkpoint holds
    GSF__COLUMNS = GSF__SAVED_COLUMNS + GSF__GROUPS + 6,  // with what lives within a step
};

// All arrays of the model that have a row per splat.
static void gsf__model_columns(const gsf__model* model, gsf__column out[GSF__COLUMNS]) {
    const gsf__column rest[] = {
        {(char*)model->ids, 4}, {(char*)model->grad_sum[0], 4}, {(char*)model->visits[0], 4},
        {(char*)model->grad_sum[1], 4}, {(char*)model->visits[1], 4}, {(char*)model->screen[0], 8},
        {(char*)model->screen[1], 8}, {(char*)model->seen[0], 1}, {(char*)model->seen[1], 1},
        {(char*)model->hidden, 1}, {(char*)model->action, 1}};
    memcpy(out + GSF__ID_COLUMN, rest, sizeof rest);
    for (int g = 0; g < GSF__GROUPS; g++) {
        const gsf__group* group = &model->groups[g];
        float* const arrays[4] = {group->value, group->m, group->v, group->grad};
        for (int k = 0; k < 4; k++) {
            gsf__column* column = out + (k < 3 ? k * GSF__GROUPS : (int)GSF__COLUMNS - (int)GSF__GROUPS) + g;
            column->data = (char*)arrays[k];
            column->row = group->width * sizeof(float);
        }
    }
}

// Grows the capacity to at least `needed` splats and keeps the existing rows. Out of memory: the model is unchanged.
static gsf_result gsf__model_reserve(gsf_context* ctx, gsf__model* model, size_t needed) {
    if (needed <= model->capacity && model->block) return GSF_OK;
    if (needed > UINT32_MAX) return gsf_fail(ctx, GSF_ERROR_OUT_OF_MEMORY, "trainer: %zu splats are too many", needed);
    size_t capacity = model->capacity + model->capacity / 8; // a trainer grows at most once per densify_interval
    capacity = ((needed > capacity ? needed : capacity) + 64) & ~(size_t)63;
    gsf__model grown = *model;
    char* block = (char*)gsf_alloc_zeroed(ctx, gsf__model_layout(&grown, capacity, NULL), 1);
    if (!block) return GSF_ERROR_OUT_OF_MEMORY;
    (void)gsf__model_layout(&grown, capacity, block);
    grown.block = block;
    grown.capacity = capacity;
    gsf__column from[GSF__COLUMNS], to[GSF__COLUMNS];
    gsf__model_columns(model, from);
    gsf__model_columns(&grown, to);
    for (int k = 0; k < GSF__COLUMNS && model->count; k++) memcpy(to[k].data, from[k].data, model->count * from[k].row);
    if (model->count) memcpy(grown.rest, model->rest, gsf__model_blocks(model->count));
    gsf_free(ctx, model->block);
    *model = grown;
    return GSF_OK;
}

static void gsf__model_destroy(gsf_context* ctx, gsf__model* model) {
    gsf_free(ctx, model->block);
    memset(model, 0, sizeof *model);
}

// Learning rate at `step`: log-linear from `first` at step 0 to `last` at max_steps, constant from there on. With
// delay_steps > 0 it is eased in, starting at delay_factor times that rate. Inria 3DGS: get_expon_lr_func.
static double gsf__exponential_rate(int32_t step, double first, double last, int32_t delay_steps, double delay_factor,
                                    int32_t max_steps) {
    if (step < 0 || (first == 0.0 && last == 0.0)) return 0.0;
    double delay = 1.0;
    if (delay_steps > 0) {
        const double u = step < delay_steps ? (double)step / delay_steps : 1.0;
        delay = delay_factor + (1.0 - delay_factor) * gsf__sin_f64(1.5707963267948966 * u);
    }
    const double t = step < max_steps ? (double)step / max_steps : 1.0;
    return delay * gsf__exp_f64(gsf__log_f64(first) * (1.0 - t) + gsf__log_f64(last) * t);
}

typedef struct gsf__adam_rates { // learning rates of one step
    double means, scales, quats, opacity, sh_dc, sh_rest;
} gsf__adam_rates;

enum { GSF__ADAM_PERIOD = 768 }; // the pattern of SH rates repeats after at most this many floats: 16 rows of (16,3)

typedef uint32_t (*gsf__adam_update_fn)(float* value, float* m, float* v, float* grad, size_t rows, size_t stride, size_t n,
                                        const float* rates, size_t period, float inv_correction2);

typedef struct gsf__rest { // the effect of n consecutive steps with zero gradient
    float drift, eps;      // the value decreases by rate * drift * m / (sqrt(v) + eps)
    float decay1, decay2;  // factors of m and v
    float rate, inv_correction2; // 1 / (1 - beta1^j) and 1 / sqrt(1 - beta2^j), where j is the first of these steps
} gsf__rest;

typedef struct gsf__lazy { // how to catch up to step t
    gsf__model* model;
    gsf__adam_update_fn update;
    int (*catch_up)(float* value, float* m, float* v, size_t n, const float* rates, const gsf__rest* rest);
    size_t active_sh;
    float rates[48];                      // learning rates of an SH row
    gsf__rest rests[GSF__REST_MOST + 1];  // [n]: n steps, the last of which is step t; [0] is all zero
} gsf__lazy;

typedef struct gsf__adam_job {
    gsf__model* model;
    float inv_correction2;           // 1 / sqrt(1 - beta2^t)
    size_t active_sh;                // leading floats of an SH row that can have a gradient
    float rates[4];                  // learning rates of the groups before SH, divided by 1 - beta1^t
    float sh_rates[GSF__ADAM_PERIOD]; // likewise of 16 SH rows
    gsf__adam_update_fn update;
} gsf__adam_job;

#define GSF__ADAM_EPS 1e-15f
// Moments too small to matter are flushed to zero; otherwise they would decay to denormals, which are slow on many
// CPUs. The root of the second threshold is 1000 times below eps.
#define GSF__ADAM_TINY_M 1e-30f
#define GSF__ADAM_TINY_V 1e-36f
#define GSF__ADAM_LARGEST 1e18f // larger gradients could overflow when squared, so they are treated as non-finite

/* Catching up in closed form. Step j with a zero gradient is
       m *= b1,  v *= b2,  value -= rate m / (c1_j (sqrt(v) / c2_j + eps)),   c1_j = 1 - b1^j,  c2_j = sqrt(1 - b2^j).
   In terms of m and v before the n skipped steps, the k-th of them (j = t - n + k) decreases the value by
       rate m / sqrt(v) * q^k c2_j / c1_j / (1 + x_k eps / sqrt(v)),   q = b1 / sqrt(b2),   x_k = c2_j b2^(-k/2).
   If eps is small compared to sqrt(v), x_k can be replaced by its mean with weights q^k c2_j / c1_j; the error is of
   second order. For given t and n all values then share
       drift = sum(q^k c2_j / c1_j)   and   eps' = eps sum(q^k c2_j / c1_j x_k) / drift.
   Without its first term, either sum is the one for n - 1 times a constant, so a single pass computes them for all n.
   Rows in which eps is not small take the steps one by one. */
#define GSF__LAZY_LEAST_V 1e-24f // sqrt(v) = 1000 eps: the second-order error is below 1e-7

static uint32_t gsf__count_bits(uint32_t bits) {
    uint32_t count = 0;
    for (; bits; bits &= bits - 1) count++;
    return count;
}

#define GSF__KERNELS "gsfixer_splat.h"
#define GSF__KERNELS_ADAM
#define GSF__KERNELS_SIMD128
#define GSF__KERNELS_AVX512
#include "gsfixer.h" // compiles what follows, once per instruction set
#undef GSF__KERNELS_ADAM

#endif // GSF__ISA
#ifdef GSF__KERNELS_ADAM

// A moment without tiny values.
GSF__V_INLINE gsf__vf GSF__V(gsf__adam_m)(gsf__vf m) {
    return gsf__v_keep(gsf__v_ge(gsf__v_abs(m), gsf__v_set(GSF__ADAM_TINY_M)), m);
}

GSF__V_INLINE gsf__vf GSF__V(gsf__adam_v)(gsf__vf v) { return gsf__v_keep(gsf__v_ge(v, gsf__v_set(GSF__ADAM_TINY_V)), v); }

// Stores `next` where it is finite, else `old`. Returns the lanes where it is finite.
GSF__V_INLINE gsf__vm GSF__V(gsf__adam_value)(float* value, gsf__vf old, gsf__vf next, size_t n) {
    const gsf__vm finite = gsf__v_le(gsf__v_abs(next), gsf__v_set(FLT_MAX));
    gsf__v_store_first(value, gsf__v_select(finite, next, old), n);
    return finite;
}

// Updates the first n lanes of one vector. Returns the number of gradients and updates discarded as non-finite.
GSF__V_INLINE uint32_t GSF__V(gsf__adam_vector)(float* value, float* m, float* v, float* grad, const float* rates,
                                                float inv_correction2, size_t n) {
    gsf__vf g = gsf__v_load_first(grad, n), mi = gsf__v_load_first(m, n), vi = gsf__v_load_first(v, n);
    const gsf__vf old = gsf__v_load_first(value, n);
    const gsf__vm good = gsf__v_le(gsf__v_abs(g), gsf__v_set(GSF__ADAM_LARGEST));
    g = gsf__v_keep(good, g);
    mi = GSF__V(gsf__adam_m)(gsf__v_madd(g - mi, gsf__v_set(0.1f), mi));
    vi = gsf__v_madd(g * gsf__v_set(0.001f), g, vi * gsf__v_set(0.999f));
    vi = GSF__V(gsf__adam_v)(vi);
    const gsf__vf root = gsf__v_madd(gsf__v_sqrt(vi), gsf__v_set(inv_correction2), gsf__v_set(GSF__ADAM_EPS));
    const gsf__vf next = gsf__v_nmadd(gsf__v_load(rates), mi / root, old);
    const gsf__vm finite = GSF__V(gsf__adam_value)(value, old, next, n);
    gsf__v_store_first(m, mi, n);
    gsf__v_store_first(v, vi, n);
    gsf__v_store_first(grad, gsf__v_set(0.0f), n);
    const uint32_t all = (1u << GSF__LANES) - 1u, good_bits = gsf__vm_bits(good), finite_bits = gsf__vm_bits(finite);
    return (good_bits & finite_bits) == all ? 0 : gsf__count_bits(all & ~good_bits) + gsf__count_bits(all & ~finite_bits);
}

// Updates `rows` runs of n values each, which start `stride` apart. rates: `period` (a multiple of 16) step sizes,
// repeated along each run. Non-finite gradients are treated as 0, and updates to a non-finite value are skipped.
// Returns how many of both there were.
GSF__V_KERNEL uint32_t GSF__V(gsf__adam_update)(float* value, float* m, float* v, float* grad, size_t rows, size_t stride,
                                                size_t n, const float* rates, size_t period, float inv_correction2) {
    uint32_t rejected = 0;
    for (size_t row = 0; row < rows; row++) {
        const size_t end = row * stride + n;
        for (size_t first = row * stride; first < end; first += period) {
            const size_t stop = end - first < period ? end : first + period;
            const float* rate = rates;
            size_t i = first;
            for (; i + GSF__LANES <= stop; i += GSF__LANES, rate += GSF__LANES)
                rejected += GSF__V(gsf__adam_vector)(value + i, m + i, v + i, grad + i, rate, inv_correction2, GSF__LANES);
            if (i < stop)
                rejected += GSF__V(gsf__adam_vector)(value + i, m + i, v + i, grad + i, rate, inv_correction2, stop - i);
        }
    }
    return rejected;
}

GSF__V_INLINE void GSF__V(gsf__lazy_vector)(float* value, float* m, float* v, const float* rates, const gsf__rest* rest,
                                            size_t n) {
    const gsf__vf old = gsf__v_load_first(value, n), mi = gsf__v_load_first(m, n), vi = gsf__v_load_first(v, n);
    const gsf__vf root = gsf__v_sqrt(vi) + gsf__v_set(rest->eps);
    const gsf__vf reach = gsf__v_load(rates) * gsf__v_set(rest->drift);
    (void)GSF__V(gsf__adam_value)(value, old, gsf__v_nmadd(reach, mi / root, old), n);
    gsf__v_store_first(m, GSF__V(gsf__adam_m)(mi * gsf__v_set(rest->decay1)), n);
    gsf__v_store_first(v, GSF__V(gsf__adam_v)(vi * gsf__v_set(rest->decay2)), n);
}

// Applies the steps of `rest` to a row of n values. Returns 0 and changes nothing if eps is not negligible for a value
// that has momentum; the steps must then be taken one by one.
GSF__V_KERNEL int GSF__V(gsf__lazy_catch_up)(float* value, float* m, float* v, size_t n, const float* rates,
                                             const gsf__rest* rest) {
    const gsf__vf zero = gsf__v_set(0.0f), least = gsf__v_set(GSF__LAZY_LEAST_V);
    const size_t whole = n - n % GSF__LANES;
    gsf__vm tiny = gsf__vm_of_bits(0);
    for (size_t i = 0; i < n; i += GSF__LANES) {
        const gsf__vf mi = gsf__v_load_first(m + i, n - i), vi = gsf__v_load_first(v + i, n - i);
        tiny = gsf__vm_or(tiny, gsf__vm_not(gsf__vm_or(gsf__v_eq(mi, zero), gsf__v_ge(vi, least))));
    }
    if (gsf__vm_bits(tiny)) return 0;
    for (size_t i = 0; i < whole; i += GSF__LANES)
        GSF__V(gsf__lazy_vector)(value + i, m + i, v + i, rates + i, rest, GSF__LANES);
    if (whole < n) GSF__V(gsf__lazy_vector)(value + whole, m + whole, v + whole, rates + whole, rest, n - whole);
    return 1;
}

#endif // GSF__KERNELS_ADAM
#ifndef GSF__ISA

// Prepares catching up to step t. `rates` are those of step t; the SH rates are the same in all steps.
static void gsf__lazy_prepare(gsf_cpu_level level, gsf__lazy* lazy, gsf__model* model, const gsf__adam_rates* rates,
                              int32_t t, int32_t sh_bands) {
    lazy->model = model;
    lazy->active_sh = 3 * (size_t)sh_bands * (size_t)sh_bands;
    for (int i = 0; i < 48; i++) lazy->rates[i] = (float)(i < 3 ? rates->sh_dc : rates->sh_rest);
    lazy->update = GSF__ANY_KERNEL_OF(level, gsf__adam_update);
    lazy->catch_up = GSF__ANY_KERNEL_OF(level, gsf__lazy_catch_up);
    memset(&lazy->rests[0], 0, sizeof lazy->rests[0]);
    const double b1 = 1.0 - (double)0.1f, b2 = (double)0.999f, root2 = sqrt(b2); // rounded as in gsf__adam_vector
    double power1 = gsf__power_f64(0.9, (uint64_t)t), power2 = gsf__power_f64(0.999, (uint64_t)t);
    double decay1 = 1.0, decay2 = 1.0, drift = 0.0, scaled = 0.0;
    for (int32_t n = 1; n <= GSF__REST_MOST && n <= t; n++) {
        gsf__rest* rest = &lazy->rests[n];
        const double c1 = 1.0 - power1, c2 = sqrt(1.0 - power2);
        power1 /= 0.9;
        power2 /= 0.999;
        drift = b1 / root2 * (c2 / c1 + drift);
        scaled = b1 / b2 * (c2 * c2 / c1 + scaled);
        rest->drift = (float)drift;
        rest->eps = (float)((double)GSF__ADAM_EPS * scaled / drift);
        rest->decay1 = (float)(decay1 *= b1);
        rest->decay2 = (float)(decay2 *= b2);
        rest->rate = (float)(1.0 / c1);
        rest->inv_correction2 = (float)(1.0 / c2);
    }
}

static void gsf__lazy_catch_up_row(const gsf__lazy* lazy, float* value, float* m, float* v, size_t rest) {
    if (lazy->catch_up(value, m, v, lazy->active_sh, lazy->rates, &lazy->rests[rest])) return;
    for (; rest > 0; rest--) {
        float rates[48], grad[48];
        memset(grad, 0, sizeof grad);
        for (int i = 0; i < 48; i++) rates[i] = lazy->rates[i] * lazy->rests[rest].rate;
        (void)lazy->update(value, m, v, grad, 1, 0, lazy->active_sh, rates, 48, lazy->rests[rest].inv_correction2);
    }
}

static void gsf__lazy_catch_up_block(const gsf__lazy* lazy, size_t block) {
    const gsf__group* sh = &lazy->model->groups[GSF__SH];
    const size_t rest = lazy->model->rest[block], end = (block + 1) * GSF__BLOCK, count = lazy->model->count;
    for (size_t i = block * GSF__BLOCK; rest && i < end && i < count; i++) {
        const size_t at = i * sh->width;
        gsf__lazy_catch_up_row(lazy, sh->value + at, sh->m + at, sh->v + at, rest);
    }
    lazy->model->rest[block] = 0;
}

static void gsf__lazy_wake(void* user, size_t splat) { // gsf_rasterizer.wake: block of a drawn splat
    const gsf__lazy* lazy = (const gsf__lazy*)user;
    const size_t block = splat / GSF__BLOCK;
    if (lazy->model->rest[block] == GSF__AWAKE) return;
    gsf__lazy_catch_up_block(lazy, block);
    lazy->model->rest[block] = GSF__AWAKE;
}

static void gsf__lazy_all_chunk(void* arg, size_t chunk, int32_t worker) { // brings a chunk up to date
    const gsf__lazy* lazy = (const gsf__lazy*)arg;
    (void)worker;
    const size_t end = gsf__model_blocks(gsf__model_chunk_end(lazy->model->count, chunk));
    for (size_t b = chunk * ((size_t)GSF__MODEL_CHUNK / GSF__BLOCK); b < end; b++) gsf__lazy_catch_up_block(lazy, b);
}

// Writes up-to-date SH to the gradient buffer, which is free between steps, and leaves the model's SH unchanged.
static void gsf__lazy_show_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__lazy* lazy = (const gsf__lazy*)arg;
    const gsf__group* sh = &lazy->model->groups[GSF__SH];
    const size_t row = sh->width * sizeof(float), end = gsf__model_chunk_end(lazy->model->count, chunk);
    (void)worker;
    for (size_t i = chunk * GSF__MODEL_CHUNK; i < end; i++) {
        const size_t rest = lazy->model->rest[i / GSF__BLOCK];
        float m[48], v[48], *shown = sh->grad + i * sh->width;
        memcpy(shown, sh->value + i * sh->width, row);
        if (!rest) continue;
        memcpy(m, sh->m + i * sh->width, row);
        memcpy(v, sh->v + i * sh->width, row);
        gsf__lazy_catch_up_row(lazy, shown, m, v, rest);
    }
}

// Lazy step for the SH of splats begin to end - 1: updates runs of awake blocks, counts a skipped step for the others.
static uint32_t gsf__adam_lazy_sh(const gsf__adam_job* job, size_t begin, size_t end) {
    const gsf__group* sh = &job->model->groups[GSF__SH];
    const size_t width = sh->width, whole = job->active_sh == width, blocks = gsf__model_blocks(end);
    uint8_t* rest = job->model->rest;
    uint32_t rejected = 0;
    for (size_t b = begin / GSF__BLOCK; b < blocks;) {
        if (rest[b] != GSF__AWAKE) {
            if (++rest[b] == GSF__REST_MOST) gsf__lazy_catch_up_block(job->model->lazy, b);
            b++;
            continue;
        }
        const size_t from = b * GSF__BLOCK;
        for (; b < blocks && rest[b] == GSF__AWAKE; b++) rest[b] = 0;
        const size_t at = from * width, rows = (b * GSF__BLOCK < end ? b * GSF__BLOCK : end) - from;
        rejected += job->update(sh->value + at, sh->m + at, sh->v + at, sh->grad + at, whole ? 1 : rows, width,
                                whole ? rows * width : job->active_sh, job->sh_rates, 16 * width, job->inv_correction2);
    }
    return rejected;
}

static void gsf__adam_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__adam_job* job = (const gsf__adam_job*)arg;
    gsf__model* model = job->model;
    (void)worker;
    const size_t begin = chunk * GSF__MODEL_CHUNK;
    const size_t rows = gsf__model_chunk_end(model->count, chunk) - begin;
    uint32_t rejected = 0;
    if (model->lazy) rejected = gsf__adam_lazy_sh(job, begin, begin + rows);
    for (int g = 0; g < GSF__GROUPS - (model->lazy != NULL); g++) {
        const gsf__group* group = &model->groups[g];
        const size_t width = group->width, at = begin * width;
        float constant[16];
        for (int i = 0; i < 16; i++) constant[i] = job->rates[g < GSF__SH ? g : 0];
        const float* rates = g == GSF__SH ? job->sh_rates : constant;
        const size_t period = g == GSF__SH ? 16 * width : 16;
        if (g == GSF__SH && job->active_sh < width)
            rejected += job->update(group->value + at, group->m + at, group->v + at, group->grad + at, rows, width,
                                    job->active_sh, rates, period, job->inv_correction2);
        else
            rejected += job->update(group->value + at, group->m + at, group->v + at, group->grad + at, 1, 0, rows * width,
                                    rates, period, job->inv_correction2);
    }
    model->rejected[chunk] = rejected;
}

// Takes Adam step t (counted from 1). sh_bands: number of SH bands that have had a gradient so far; the moments of the
// others are zero, so skipping them is exact. In lazy models, only splats of GSF__AWAKE blocks may have an SH gradient.
// Returns the number of gradients and updates discarded as non-finite.
static size_t gsf__adam_step(gsf_context* ctx, gsf__model* model, const gsf__adam_rates* rates, int32_t t,
                             int32_t sh_bands) {
    gsf__adam_job job;
    memset(&job, 0, sizeof job);
    job.model = model;
    const double correction1 = 1.0 - gsf__power_f64(0.9, (uint64_t)t);
    job.inv_correction2 = (float)(1.0 / sqrt(1.0 - gsf__power_f64(0.999, (uint64_t)t)));
    job.rates[GSF__MEANS] = (float)(rates->means / correction1);
    job.rates[GSF__SCALES] = (float)(rates->scales / correction1);
    job.rates[GSF__QUATS] = (float)(rates->quats / correction1);
    job.rates[GSF__OPACITY] = (float)(rates->opacity / correction1);
    const size_t width = model->groups[GSF__SH].width;
    for (size_t i = 0; i < 16 * width; i++)
        job.sh_rates[i] = (float)((i % width < 3 ? rates->sh_dc : rates->sh_rest) / correction1);
    job.active_sh = 3 * (size_t)sh_bands * (size_t)sh_bands;
    job.update = GSF__ANY_KERNEL_OF(ctx->cpu_level, gsf__adam_update);
    if (model->lazy) gsf__lazy_prepare(ctx->cpu_level, model->lazy, model, rates, t, sh_bands);
    const size_t chunks = gsf__model_chunks(model->count);
    gsf__parallel_for(ctx, chunks, gsf__adam_chunk, &job);
    size_t rejected = 0;
    for (size_t i = 0; i < chunks; i++) rejected += model->rejected[i];
    return rejected;
}

// ---- >>densify -----------------------------------------------------------------
// Adaptive density control of 3DGS: splats with a large mean screen-space gradient are cloned if small and split in
// two if large (scales / 1.6, means sampled from the splat's Gaussian), then transparent and oversized splats are
// pruned. Row order as in the Inria 3DGS code: kept originals, clones, first halves, second halves. Its pruning by
// screen size is omitted, because it never triggers there (the radii are zeroed before the test). With `shared`, the
// render changes less (see gsf_train_desc.densify_shared). The alternative, MCMC, follows below.

typedef enum gsf__densify_action { GSF__KEEP = 0, GSF__CLONE, GSF__SPLIT } gsf__densify_action;

typedef struct gsf__densify_rule {
    float grad;            // threshold of the mean gradient norm
    double clone_scale;    // splats up to this size (largest axis) are cloned, larger ones split
    double prune_opacity;  // splats with a lower opacity are removed
    double prune_scale;    // splats larger than this are removed, too; 0 = off
    size_t max_splats;
    int shared;            // new splats share the opacity of the old one
    uint64_t seed, stream; // of the random offsets, which also depend on the splat's id
    const float* normals;  // (2, splits, 3) standard normal samples to use instead; NULL = draw them
} gsf__densify_rule;

static float gsf__densify_mean(float grad_sum, uint32_t visits) {
    const float mean = visits ? grad_sum / (float)visits : 0.0f;
    return mean <= FLT_MAX ? mean : 0.0f;
}

// The larger of the means over photos and over restored views. A common mean would let one kind dilute the other.
static float gsf__densify_mean_grad(const gsf__model* model, size_t i) {
    float largest = 0.0f;
    for (int k = 0; k < 2; k++) {
        const float mean = gsf__densify_mean(model->grad_sum[k][i], model->visits[k][i]);
        if (mean > largest) largest = mean;
    }
    return largest;
}

static int gsf__model_longest_axis(const gsf__model* model, size_t i) {
    const float* s = model->groups[GSF__SCALES].value + 3 * i;
    const int longest = s[0] >= s[1] ? 0 : 1;
    return s[longest] >= s[2] ? longest : 2;
}

static float gsf__model_max_log_scale(const gsf__model* model, size_t i) {
    return model->groups[GSF__SCALES].value[3 * i + (size_t)gsf__model_longest_axis(model, i)];
}

static float gsf__positive_float(uint32_t bits) { // floats >= 0 are ordered like their bit patterns
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

// Smallest threshold >= `threshold` that at most `room` splats reach, found by bisection over the bit patterns.
static float gsf__densify_cap(const gsf__model* model, float threshold, size_t room) {
    uint32_t low, high = 0x7f800000u; // +inf, which no splat reaches
    memcpy(&low, &threshold, sizeof low);
    while (low < high) {
        const uint32_t middle = low + (high - low) / 2;
        const float value = gsf__positive_float(middle);
        size_t reached = 0;
        for (size_t i = 0; i < model->count; i++) reached += gsf__densify_mean_grad(model, i) >= value;
        if (reached <= room) high = middle;
        else low = middle + 1;
    }
    return gsf__positive_float(low);
}

// Sets model->action of every splat and counts clones and splits. If max_splats leaves no room for all candidates,
// those with the largest gradients are taken.
static void gsf__densify_select(const gsf__model* model, const gsf__densify_rule* rule, size_t* clones, size_t* splits) {
    const float clone_log = (float)gsf__log_f64(rule->clone_scale);
    float threshold = rule->grad;
    const size_t room = rule->max_splats > model->count ? rule->max_splats - model->count : 0;
    *clones = *splits = 0;
    for (int capped = 0; capped < 2; capped++) {
        *clones = *splits = 0;
        for (size_t i = 0; i < model->count; i++) {
            uint8_t action = GSF__KEEP;
            if (gsf__densify_mean_grad(model, i) >= threshold)
                action = gsf__model_max_log_scale(model, i) <= clone_log ? GSF__CLONE : GSF__SPLIT;
            *clones += action == GSF__CLONE;
            *splits += action == GSF__SPLIT;
            model->action[i] = action;
        }
        if (*clones + *splits <= room) return;
        threshold = gsf__densify_cap(model, threshold, room);
    }
}

static void gsf__model_clear_moments(gsf__model* model, size_t i) {
    gsf__column columns[GSF__COLUMNS];
    gsf__model_columns(model, columns);
    for (int k = GSF__MOMENT_COLUMNS; k < GSF__ID_COLUMN; k++) memset(columns[k].data + i * columns[k].row, 0, columns[k].row);
}

static void gsf__model_copy_row(gsf__model* model, size_t from, size_t to) { // as a new splat: zero moments, new id
    for (int g = 0; g < GSF__GROUPS; g++) {
        const size_t width = model->groups[g].width;
        float* value = model->groups[g].value;
        memcpy(value + to * width, value + from * width, width * sizeof(float));
    }
    gsf__model_clear_moments(model, to);
    model->action[to] = GSF__KEEP;
    model->ids[to] = model->next_id++;
}

// Rotation matrix (row-major) of a raw quaternion w x y z; the zero quaternion gives the identity.
static void gsf__densify_rotation(const float* q, double r[9]) {
    double w = (double)q[0], x = (double)q[1], y = (double)q[2], z = (double)q[3];
    const double norm = sqrt(w * w + x * x + y * y + z * z);
    if (norm < 1e-12) w = 1.0, x = y = z = 0.0;
    else w /= norm, x /= norm, y /= norm, z /= norm;
    r[0] = 1.0 - 2.0 * (y * y + z * z), r[1] = 2.0 * (x * y - w * z), r[2] = 2.0 * (x * z + w * y);
    r[3] = 2.0 * (x * y + w * z), r[4] = 1.0 - 2.0 * (x * x + z * z), r[5] = 2.0 * (y * z - w * x);
    r[6] = 2.0 * (x * z - w * y), r[7] = 2.0 * (y * z + w * x), r[8] = 1.0 - 2.0 * (x * x + y * y);
}

static void gsf__densify_clear(gsf__model* model) { // resets the statistics
    for (int k = 0; k < 2; k++) memset(model->grad_sum[k], 0, model->count * sizeof(float));
    for (int k = 0; k < 2; k++) memset(model->visits[k], 0, model->count * sizeof(uint32_t));
}

// Moves a splat by `offset`, given along its axes.
static void gsf__densify_move(gsf__model* model, size_t i, const double offset[3]) {
    float* mean = model->groups[GSF__MEANS].value + 3 * i;
    double r[9];
    gsf__densify_rotation(model->groups[GSF__QUATS].value + 4 * i, r);
    for (int a = 0; a < 3; a++) {
        const double moved =
            (double)mean[a] + r[3 * a] * offset[0] + r[3 * a + 1] * offset[1] + r[3 * a + 2] * offset[2];
        if (fabs(moved) <= (double)FLT_MAX) mean[a] = (float)moved;
    }
}

static void gsf__densify_child(gsf__model* model, size_t parent, size_t child, const double normal[3]) {
    gsf__model_copy_row(model, parent, child);
    float* scale = model->groups[GSF__SCALES].value + 3 * child;
    double offset[3];
    for (int a = 0; a < 3; a++) offset[a] = gsf__exp_f64((double)scale[a]) * normal[a];
    gsf__densify_move(model, child, offset);
    for (int a = 0; a < 3; a++) scale[a] -= 0.47000363f; // log(1.6)
}

// Gives a splat of opacity o the opacity 1 - sqrt(1 - o), of which two are as opaque as it was.
static void gsf__densify_share(gsf__model* model, size_t i) {
    float* logit = model->groups[GSF__OPACITY].value + i;
    const double clear = 1.0 / (1.0 + gsf__exp_f64((double)*logit)), each = sqrt(clear > 1e-12 ? clear : 1e-12);
    *logit = (float)(gsf__log1p_f64(-each) - gsf__log_f64(each));
}

// One of the two parts of a splat with a shared opacity. side: -1 or 1.
static void gsf__densify_part(gsf__model* model, size_t parent, size_t child, double side) {
    const int longest = gsf__model_longest_axis(model, parent);
    gsf__model_copy_row(model, parent, child);
    float* scale = model->groups[GSF__SCALES].value + 3 * child + longest;
    double offset[3] = {0.0, 0.0, 0.0};
    offset[longest] = side * 0.5 * gsf__exp_f64((double)*scale);
    gsf__densify_move(model, child, offset);
    *scale -= 0.41551544f; // log(0.66)
    gsf__densify_share(model, child);
}

// Removes split parents and the splats to be pruned; the order of the others is kept. Resets the statistics.
static void gsf__densify_compact(gsf__model* model, const gsf__densify_rule* rule) {
    const float opacity_logit = (float)gsf__log_f64(rule->prune_opacity / (1.0 - rule->prune_opacity));
    const float scale_log = rule->prune_scale > 0.0 ? (float)gsf__log_f64(rule->prune_scale) : FLT_MAX;
    gsf__column columns[GSF__COLUMNS];
    gsf__model_columns(model, columns);
    size_t kept = 0;
    for (size_t i = 0; i < model->count; i++) {
        if (model->action[i] == GSF__SPLIT || model->groups[GSF__OPACITY].value[i] < opacity_logit ||
            gsf__model_max_log_scale(model, i) > scale_log)
            continue;
        for (int k = 0; k <= GSF__ID_COLUMN && kept != i; k++) // gradients need no copy: all are zero between steps
            memcpy(columns[k].data + kept * columns[k].row, columns[k].data + i * columns[k].row, columns[k].row);
        kept++;
    }
    model->count = kept;
    gsf__densify_clear(model);
}

// Carries out the actions set by gsf__densify_select. Needs capacity for count + clones + 2 splits.
static void gsf__densify_apply(gsf__model* model, const gsf__densify_rule* rule, size_t clones, size_t splits) {
    const size_t count = model->count;
    size_t clone = count, child = count + clones;
    for (size_t i = 0; i < count; i++) {
        if (model->action[i] == GSF__CLONE) {
            if (rule->shared) gsf__densify_share(model, i);
            gsf__model_copy_row(model, i, clone++);
        }
        if (model->action[i] != GSF__SPLIT) continue;
        for (size_t copy = 0; copy < 2; copy++) {
            double normal[3];
            if (rule->shared) {
                gsf__densify_part(model, i, child + copy * splits, copy ? 1.0 : -1.0);
                continue;
            }
            for (size_t a = 0; a < 3; a++)
                normal[a] = rule->normals ? (double)rule->normals[(copy * splits + (child - count - clones)) * 3 + a]
                                          : gsf_draw_normal(rule->seed, rule->stream,
                                                            (uint64_t)model->ids[i] * 6 + copy * 3 + a);
            gsf__densify_child(model, i, child + copy * splits, normal);
        }
        child++;
    }
    model->count = count + clones + 2 * splits;
    gsf__densify_compact(model, rule);
}

/* 3DGS as Markov Chain Monte Carlo (Kheradmand et al. 2024). Nearly transparent splats are relocated, and new splats
   are added up to a budget: both become copies of other splats, drawn with probability proportional to opacity. When a
   splat of opacity o is replaced by N copies, each gets opacity o' = 1 - (1 - o)^(1/N), so that together they are as
   opaque at the centre as before, and its scales are multiplied by
       o / sum_{i=1..N} sum_{k=0..i-1} C(i-1,k) (-1)^k o'^(k+1) / sqrt(k+1),
   so that 1 - (1 - o' g)^N, what the copies blend to, has the same integral across the splat as o g had. For each k the
   binomials add up to C(N,k+1), so with j = k + 1 a single sum of (-1)^(j+1) C(N,j) o'^j / sqrt(j) remains. */
enum { GSF__MCMC_MOST = 51 }; // N is clamped to this, as in gsplat

// Sets *opacity to o' and returns the factor of the scales. transparency: 1 - o. The sum alternates; its error in
// double is below 1e-12.
static double gsf__mcmc_share(double transparency, uint32_t copies, double* opacity) {
    double term = 1.0, sum = 0.0;
    *opacity = -gsf__expm1_f64(gsf__log_f64(transparency) / (double)copies);
    for (uint32_t j = 1; j <= copies; j++) {
        term *= -*opacity * (double)(copies - j + 1) / (double)j;
        sum -= term / sqrt((double)j);
    }
    return (1.0 - transparency) / sum;
}

// Draws `draws` splats (with repetition) among those with an opacity logit of at least `logit` and stores their indices in
// visits[1] and how often each was drawn in visits[0]. screen[0] holds the cumulative opacities. MCMC uses none of
// these for statistics. Returns the number of draws made: 0 if there is no such splat.
static size_t gsf__mcmc_draw(gsf__model* model, const gsf__densify_rule* rule, float logit, size_t draws, size_t index) {
    double *sums = (double*)(void*)model->screen[0], total = 0.0; // two floats per splat hold a double
    memset(model->visits[0], 0, model->count * sizeof(uint32_t));
    for (size_t i = 0; i < model->count; i++) {
        const float x = model->groups[GSF__OPACITY].value[i];
        if (x >= logit) total += (double)gsf__sigmoid(x);
        sums[i] = total;
    }
    if (!(total > 0.0)) return 0;
    for (size_t k = 0; k < draws; k++) {
        const double at = total * gsf_draw_uniform(rule->seed, rule->stream, index + k); // < total
        size_t low = 0, high = model->count - 1;
        while (low < high) { // first cumulative sum above `at`
            const size_t middle = low + (high - low) / 2;
            if (sums[middle] > at) high = middle;
            else low = middle + 1;
        }
        model->visits[1][k] = (uint32_t)low;
        model->visits[0][low]++;
    }
    return draws;
}

// Gives every drawn splat the opacity and scales that it will share with its copies. Opacities are clamped to at least
// least_opacity, as in gsplat; unlike there, a splat of exactly that opacity is not relocated.
static void gsf__mcmc_correct(gsf__model* model, double least_opacity) {
    for (size_t i = 0; i < model->count; i++) {
        if (model->visits[0][i] == 0) continue;
        float *logit = model->groups[GSF__OPACITY].value + i, *scale = model->groups[GSF__SCALES].value + 3 * i;
        const uint32_t most = GSF__MCMC_MOST, copies = model->visits[0][i] < most ? model->visits[0][i] + 1 : most;
        const double clear = 1.0 / (1.0 + gsf__exp_f64((double)*logit));
        double opacity;
        const double shared = clear > (double)FLT_EPSILON ? clear : (double)FLT_EPSILON;
        const float grown = (float)gsf__log_f64(gsf__mcmc_share(shared, copies, &opacity));
        if (opacity < least_opacity) opacity = least_opacity;
        *logit = (float)gsf__log_f64(opacity / (1.0 - opacity));
        for (int a = 0; a < 3; a++) scale[a] += grown;
        gsf__model_clear_moments(model, i);
    }
}

static size_t gsf__mcmc_growth(size_t count, size_t budget) { // number of splats to add: 5 %, within the budget
    const size_t room = budget > count ? budget - count : 0;
    return count / 20 < room ? count / 20 : room;
}

// Makes `draws` copies of drawn splats. They overwrite the rows from `first` on whose opacity logit is below `logit`,
// and continue past the last splat. Drawn splats are not overwritten: their correction does not go below `logit`.
static size_t gsf__mcmc_copy(gsf__model* model, const gsf__densify_rule* rule, float logit, size_t draws, size_t first) {
    const float* logits = model->groups[GSF__OPACITY].value;
    const size_t count = model->count, drawn = gsf__mcmc_draw(model, rule, logit, draws, first);
    gsf__mcmc_correct(model, rule->prune_opacity);
    for (size_t k = 0, to = first; k < drawn; to++)
        if (to >= count || logits[to] < logit)
            gsf__model_copy_row(model, model->visits[1][k++], to);
    return drawn;
}

// Needs capacity for the splats that gsf__mcmc_growth adds.
static void gsf__mcmc_densify(gsf__model* model, const gsf__densify_rule* rule) {
    const float logit = (float)gsf__log_f64(rule->prune_opacity / (1.0 - rule->prune_opacity));
    const size_t count = model->count;
    size_t dead = 0;
    for (size_t i = 0; i < count; i++) dead += model->groups[GSF__OPACITY].value[i] < logit;
    (void)gsf__mcmc_copy(model, rule, logit, dead, 0);
    model->count += gsf__mcmc_copy(model, rule, logit, gsf__mcmc_growth(count, rule->max_splats), count);
    gsf__densify_clear(model);
}

// Lowers opacities above `limit` to it and zeroes the moments of all opacities.
static void gsf__reset_opacity(gsf__model* model, double limit) {
    const float logit = (float)gsf__log_f64(limit / (1.0 - limit));
    gsf__group* group = &model->groups[GSF__OPACITY];
    for (size_t i = 0; i < model->count; i++)
        if (group->value[i] > logit) group->value[i] = logit;
    memset(group->m, 0, model->count * sizeof(float));
    memset(group->v, 0, model->count * sizeof(float));
}

// ---- >>trainer -----------------------------------------------------------------
// A step renders the next photo of a random permutation, computes the loss and its gradient, does the same for one
// restored view, takes an Adam step with the summed gradients and then runs density control. Two points differ from the
// GSFixer release. Its loader samples photos with replacement. And it runs Adam after density control, so the Adam step
// of every densification is lost, because the new tensors have no gradient yet; here no step is lost.
// If a step fails (out of memory, cancelled), the trainer is unchanged.

enum { // kinds of random streams; gsf__stream combines them with the iteration or epoch
    GSF__STREAM_PHOTOS = 1, GSF__STREAM_RESTORED, GSF__STREAM_SPLIT, GSF__STREAM_DROPOUT, GSF__STREAM_DROPOUT_RESTORED,
    GSF__STREAM_NOISE, GSF__STREAM_BACKGROUND
};

enum { GSF__DECAY_INTERVAL = 10 }; // iterations between opacity decays

typedef struct gsf__photo {
    gsf_camera camera;
    gsf__target target;
    void *pixels, *weight;   // owned; `target` points to them
} gsf__photo;

typedef struct gsf__photo_set {
    size_t count;
    gsf__photo* photos;
    uint32_t* order;         // random permutation of the photos
    uint64_t order_epoch;    // 1 + the epoch of `order`; 0 = none yet
    int32_t max_width, max_height;
} gsf__photo_set;

struct gsf_trainer {
    gsf_train_desc desc;     // with defaults filled in
    gsf__photo_set photos, restored;
    gsf__photo_set coarse;   // the photos at half their size; empty unless desc.coarse_until
    gsf__model model;
    gsf__loss_scratch loss;
    gsf_rasterizer* rasterizer;
    float *color, *d_color, *depth, *d_depth; // packed images of the current render
    float* means;            // those that a sharpness-aware step has moved, as they were
    size_t color_capacity, d_color_capacity, depth_capacity, d_depth_capacity, means_capacity;
    gsf_splats view;         // the model's arrays as splats; with lazy_adam, some SH are out of date
    gsf__lazy lazy;          // model.lazy points here if desc.lazy_adam is set
    gsf_splats shown;        // `view` with all SH up to date
    int shows;               // is `shown` valid?
    int32_t iteration;       // number of steps taken
    int32_t first_bands;     // number of SH bands that the initial splats use
    uint64_t restored_steps;
    float restored_weight;
    size_t rejected;
};

static uint64_t gsf__stream(uint64_t kind, uint64_t step) { return kind << 40 | step; }

static void gsf__photo_set_destroy(gsf_context* ctx, gsf__photo_set* set) {
    for (size_t i = 0; set->photos && i < set->count; i++) {
        gsf_free(ctx, set->photos[i].pixels);
        gsf_free(ctx, set->photos[i].weight);
    }
    gsf_free(ctx, set->photos);
    gsf_free(ctx, set->order);
    memset(set, 0, sizeof *set);
}

// Copies an image to packed (H,W,C) of the same dtype. Floats that are NaN or outside [low, high] are an error.
static gsf_result gsf__photo_copy(gsf_context* ctx, const gsf_image* image, const char* what, size_t index, float low,
                                  float high, void* out) {
    const size_t channels = (size_t)image->channels;
    for (int64_t y = 0; y < image->height; y++)
        for (int64_t x = 0; x < image->width; x++)
            for (size_t c = 0; c < channels; c++) {
                const char* from = (const char*)image->data + y * image->stride_y + x * image->stride_x +
                                   (int64_t)c * image->stride_c;
                const size_t to = ((size_t)y * (size_t)image->width + (size_t)x) * channels + c;
                if (image->dtype == GSF_U8) {
                    ((uint8_t*)out)[to] = *(const uint8_t*)from;
                    continue;
                }
                float value;
                memcpy(&value, from, sizeof value);
                if (!(value >= low && value <= high))
                    return gsf_fail(ctx, GSF_ERROR_NUMERIC, "%s %zu: pixel (%lld, %lld) has the invalid value %g",
                                    what, index, (long long)x, (long long)y, (double)value);
                ((float*)out)[to] = value;
            }
    return GSF_OK;
}

// Sets the weights of a photo, after its pixels. Pixels with weight 0 become black, as gsf__loss expects.
static gsf_result gsf__photo_weigh(gsf_context* ctx, const gsf_image* weight, size_t index, gsf__photo* photo) {
    const size_t pixels = (size_t)weight->width * (size_t)weight->height;
    const size_t bytes = 3 * gsf__dtype_size(photo->target.u8 ? GSF_U8 : GSF_F32);
    float* out = (float*)gsf_alloc(ctx, pixels, sizeof(float));
    if (!out) return GSF_ERROR_OUT_OF_MEMORY;
    photo->weight = out;
    photo->target.weight = out;
    if (weight->dtype == GSF_U8) {
        gsf_image floats = gsf_wrap_image(out, GSF_F32, weight->width, weight->height, 1);
        floats.color_space = weight->color_space;
        GSF__TRY(gsf_convert_image(ctx, weight, &floats));
    } else {
        GSF__TRY(gsf__photo_copy(ctx, weight, "weight of view", index, 0.0f, 1e6f, out));
    }
    for (size_t i = 0; i < pixels; i++)
        if (!(out[i] > 0.0f)) memset((char*)photo->pixels + i * bytes, 0, bytes);
    return GSF_OK;
}

static gsf_result gsf__photo_make(gsf_context* ctx, const gsf_train_view* view, const char* what, size_t index,
                                  gsf__photo* out) {
    const gsf_camera* camera = &view->camera;
    if (gsf_check_camera(ctx, camera) != GSF_OK)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s %zu: %s", what, index, ctx->error);
    const gsf_image *image = &view->image, *weight = &view->weight;
    if (!image->data || image->width != camera->width || image->height != camera->height || image->channels != 3 ||
        (image->dtype != GSF_U8 && image->dtype != GSF_F32))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s %zu: image must be u8 or f32 RGB of %d x %d", what, index,
                        (int)camera->width, (int)camera->height);
    if (weight->data && (weight->width != camera->width || weight->height != camera->height ||
                         weight->channels != 1 || (weight->dtype != GSF_F32 && weight->dtype != GSF_U8)))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "%s %zu: weight must be u8 or f32, one channel, %d x %d", what,
                        index, (int)camera->width, (int)camera->height);
    const size_t pixels = (size_t)camera->width * (size_t)camera->height;
    out->camera = *camera;
    out->target.width = camera->width;
    out->target.height = camera->height;
    const int linear = image->color_space == GSF_COLOR_LINEAR; // stored sRGB-encoded, as floats
    const gsf_dtype kept = linear ? GSF_F32 : image->dtype;
    out->pixels = gsf_alloc(ctx, pixels, 3 * gsf__dtype_size(kept));
    if (!out->pixels) return GSF_ERROR_OUT_OF_MEMORY;
    if (kept == GSF_U8) out->target.u8 = (const uint8_t*)out->pixels;
    else out->target.f32 = (const float*)out->pixels;
    gsf_image floats = gsf_wrap_image(out->pixels, GSF_F32, image->width, image->height, 3);
    floats.color_space = image->color_space;
    if (kept == image->dtype) GSF__TRY(gsf__photo_copy(ctx, image, what, index, -FLT_MAX, FLT_MAX, out->pixels));
    else GSF__TRY(gsf_convert_image(ctx, image, &floats));
    if (linear) {
        const gsf_image encoded = gsf_wrap_image(out->pixels, GSF_F32, image->width, image->height, 3);
        GSF__TRY(gsf_convert_image(ctx, &floats, &encoded));
    }
    return weight->data ? gsf__photo_weigh(ctx, weight, index, out) : GSF_OK;
}

// Memory: 3 bytes (u8) or 12 (f32) per pixel, and 4 more with a weight.
static gsf_result gsf__photo_set_make(gsf_context* ctx, const gsf_train_view* views, size_t count, const char* what,
                                      gsf__photo_set* out) {
    memset(out, 0, sizeof *out);
    if (count == 0) return GSF_OK;
    if (!views || count > UINT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "trainer: invalid list of %zu %ss at %p", count, what,
                        (const void*)views);
    out->count = count;
    out->photos = (gsf__photo*)gsf_alloc_zeroed(ctx, count, sizeof *out->photos);
    out->order = (uint32_t*)gsf_alloc(ctx, count, sizeof *out->order);
    gsf_result result = out->photos && out->order ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    size_t linear = 0;
    for (size_t i = 0; result == GSF_OK && i < count; i++) {
        gsf__photo* photo = &out->photos[i];
        linear += views[i].image.color_space == GSF_COLOR_LINEAR;
        result = gsf__photo_make(ctx, &views[i], what, i, photo);
        if (result != GSF_OK) break;
        if (photo->camera.width > out->max_width) out->max_width = photo->camera.width;
        if (photo->camera.height > out->max_height) out->max_height = photo->camera.height;
    }
    if (linear) gsf_log(ctx, GSF_LOG_INFO, "trainer: %zu of %zu %ss are linear: encoded as sRGB", linear, count, what);
    if (result != GSF_OK) gsf__photo_set_destroy(ctx, out);
    return result;
}

// Copies a photo at half its size: means of 2 x 2 pixels by their weights. An odd last row or column is left out.
static gsf_result gsf__photo_halve(gsf_context* ctx, const gsf__photo* photo, gsf__photo* out) {
    const gsf__target* from = &photo->target;
    const size_t width = (size_t)from->width / 2, height = (size_t)from->height / 2, stride = (size_t)from->width;
    out->camera = photo->camera;
    out->camera.width = out->target.width = (int32_t)width;
    out->camera.height = out->target.height = (int32_t)height;
    out->camera.fx *= 0.5, out->camera.fy *= 0.5, out->camera.cx *= 0.5, out->camera.cy *= 0.5;
    out->pixels = gsf_alloc(ctx, width * height, 3 * gsf__dtype_size(from->u8 ? GSF_U8 : GSF_F32));
    if (from->weight) out->weight = gsf_alloc(ctx, width * height, sizeof(float));
    if (!out->pixels || (from->weight && !out->weight)) return GSF_ERROR_OUT_OF_MEMORY;
    uint8_t* bytes = from->u8 ? (uint8_t*)out->pixels : NULL;
    float *floats = from->u8 ? NULL : (float*)out->pixels, *weights = (float*)out->weight;
    out->target.u8 = bytes;
    out->target.f32 = floats;
    out->target.weight = weights;
    for (size_t i = 0; i < width * height; i++) {
        const size_t first = 2 * (i / width) * stride + 2 * (i % width);
        const size_t at[4] = {first, first + 1, first + stride, first + stride + 1};
        float total = 0.0f, sum[3] = {0.0f, 0.0f, 0.0f};
        for (int k = 0; k < 4; k++) {
            const float w = from->weight ? from->weight[at[k]] : 1.0f;
            total += w;
            for (size_t c = 0; c < 3 && w > 0.0f; c++)
                sum[c] += w * (from->u8 ? (float)from->u8[3 * at[k] + c] : from->f32[3 * at[k] + c]);
        }
        for (size_t c = 0; c < 3; c++) {
            const float value = total > 0.0f ? sum[c] / total : 0.0f;
            if (bytes) bytes[3 * i + c] = (uint8_t)(value + 0.5f);
            else floats[3 * i + c] = value;
        }
        if (weights) weights[i] = 0.25f * total;
    }
    return GSF_OK;
}

enum { GSF__COARSE_LEAST = 32 }; // pixels: photos with a shorter side are not halved

static gsf_result gsf__photo_set_halve(gsf_context* ctx, const gsf__photo_set* set, gsf__photo_set* out) {
    for (size_t i = 0; i < set->count; i++)
        if (set->photos[i].camera.width < GSF__COARSE_LEAST || set->photos[i].camera.height < GSF__COARSE_LEAST) return GSF_OK;
    out->photos = (gsf__photo*)gsf_alloc_zeroed(ctx, set->count, sizeof *out->photos);
    if (!out->photos) return GSF_ERROR_OUT_OF_MEMORY;
    out->count = set->count;
    for (size_t i = 0; i < set->count; i++) GSF__TRY(gsf__photo_halve(ctx, set->photos + i, out->photos + i));
    return GSF_OK;
}

// The photo of step `step` (from 0). Every `count` steps there is a new permutation, a function of the arguments only.
static gsf__photo* gsf__photo_at(gsf__photo_set* set, uint64_t seed, uint64_t kind, uint64_t step) {
    const uint64_t epoch = step / set->count;
    if (set->order_epoch != epoch + 1) {
        for (size_t i = 0; i < set->count; i++) set->order[i] = (uint32_t)i;
        for (size_t i = set->count - 1; i > 0; i--) {
            const size_t j = (size_t)(gsf_draw_bits(seed, gsf__stream(kind, epoch), i) % (i + 1));
            const uint32_t swapped = set->order[i];
            set->order[i] = set->order[j];
            set->order[j] = swapped;
        }
        set->order_epoch = epoch + 1;
    }
    return &set->photos[set->order[step % set->count]];
}

// The interval `set` in the desc; if 0, the default for 30000 iterations, scaled to `iterations`, but at least `least`.
static int32_t gsf__scaled_interval(int32_t set, int32_t official, int32_t iterations, int32_t least) {
    if (set != 0) return set;
    const double scaled = floor((double)official * ((double)iterations / 30000.0) + 0.5);
    return scaled > (double)least ? (int32_t)scaled : least;
}

static gsf_train_desc gsf__train_desc_defaults(const gsf_train_desc* desc) {
    gsf_train_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.iterations == 0) d.iterations = 30000;
    d.sh_interval = gsf__scaled_interval(d.sh_interval, 1000, d.iterations, 1);
    d.densify_from = d.densify_from < 0 ? 0 : gsf__scaled_interval(d.densify_from, 500, d.iterations, 1);
    d.densify_until = gsf__scaled_interval(d.densify_until, d.mcmc ? 25000 : 15000, d.iterations, 1);
    if (d.densify_interval == 0) d.densify_interval = 100;
    d.opacity_reset_interval = gsf__scaled_interval(d.opacity_reset_interval, 3000, d.iterations, 1000);
    d.lr_means = gsf__or_zero(d.lr_means, 1.6e-4f);
    if (d.lr_means_final == 0.0f) d.lr_means_final = 1.6e-6f; // exponential decay cannot reach 0
    d.lr_sh_dc = gsf__or_zero(d.lr_sh_dc, 2.5e-3f);
    d.lr_sh_rest = gsf__or_zero(d.lr_sh_rest, 1.25e-4f);
    d.lr_opacity = gsf__or_zero(d.lr_opacity, 0.025f);
    d.lr_scales = gsf__or_zero(d.lr_scales, 5e-3f);
    d.lr_quats = gsf__or_zero(d.lr_quats, 1e-3f);
    d.lambda_ssim = gsf__or_zero(d.lambda_ssim, 0.2f);
    d.densify_grad = gsf__or_zero(d.densify_grad, 2e-4f);
    d.densify_scale = gsf__or_zero(d.densify_scale, 0.01f);
    d.prune_opacity = gsf__or_zero(d.prune_opacity, 0.005f);
    if (d.prune_scale == 0.0f) d.prune_scale = 0.1f;
    if (d.sharpness_from == 0) d.sharpness_from = (int32_t)((int64_t)d.iterations * 3 / 4);
    if (d.sharpness_from < 0) d.sharpness_from = 0;
    if (d.max_splats == 0) d.max_splats = d.mcmc ? 1000000 : 2000000;
    if (d.mcmc) { // defaults of the MCMC authors' code (3dgs-mcmc)
        d.opacity_reset_interval = -1;
        d.mcmc_noise = gsf__or_zero(d.mcmc_noise, 5e5f);
        d.scale_penalty = gsf__or_zero(d.scale_penalty, 0.01f);
        d.opacity_penalty = gsf__or_zero(d.opacity_penalty, 0.01f);
    }
    return d;
}

enum { GSF__TRAIN_FIELDS = 45 };

// Every field that a run depends on, with its legal range. `d` has its defaults filled in, except perhaps for the extent.
static void gsf__train_fields(const gsf_train_desc* d, gsf__field out[GSF__TRAIN_FIELDS]) {
    const gsf__field fields[GSF__TRAIN_FIELDS] = {
        {"iterations", (double)d->iterations, 1, 1e9},
        {"seed", (double)d->seed, 0, INFINITY},
        {"coarse_until", (double)d->coarse_until, 0, 1e9},
        {"sh_degree", (double)d->sh_degree, 0, 3},
        {"sh_interval", (double)d->sh_interval, 1, 1e9},
        {"densify_from", (double)d->densify_from, 0, 1e9},
        {"densify_until", (double)d->densify_until, -1e9, 1e9},
        {"densify_interval", (double)d->densify_interval, 1, 1e9},
        {"opacity_reset_interval", (double)d->opacity_reset_interval, -1e9, 1e9},
        {"lr_means", (double)d->lr_means, 0, 1e3},
        {"lr_means_final", (double)d->lr_means_final, 1e-30, 1e3},
        {"lr_means_delay_steps", (double)d->lr_means_delay_steps, 0, 1e9},
        {"lr_means_delay", (double)d->lr_means_delay, 0, 1},
        {"lr_sh_dc", (double)d->lr_sh_dc, 0, 1e3},
        {"lr_sh_rest", (double)d->lr_sh_rest, 0, 1e3},
        {"lr_opacity", (double)d->lr_opacity, 0, 1e3},
        {"lr_scales", (double)d->lr_scales, 0, 1e3},
        {"lr_quats", (double)d->lr_quats, 0, 1e3},
        {"extent", (double)d->extent, 0, 1e30},
        {"lambda_ssim", (double)d->lambda_ssim, 0, 1},
        {"background[0]", (double)d->background[0], -1e3, 1e3},
        {"background[1]", (double)d->background[1], -1e3, 1e3},
        {"background[2]", (double)d->background[2], -1e3, 1e3},
        {"background_kind", (double)d->background_kind, 0, GSF_BACKGROUND_RANDOM},
        {"densify_grad", (double)d->densify_grad, 0, 1e30},
        {"densify_scale", (double)d->densify_scale, 0, 1e30},
        {"densify_absolute", (double)d->densify_absolute, -INFINITY, INFINITY},
        {"densify_shared", (double)d->densify_shared, 0, 1},
        {"prune_opacity", (double)d->prune_opacity, 0, 0.99},
        {"prune_scale", (double)d->prune_scale, 0, 1e30},
        {"max_splats", (double)d->max_splats, 0, UINT32_MAX / 4},
        {"mcmc", (double)d->mcmc, 0, 1},
        {"mcmc_noise", (double)d->mcmc_noise, 0, 1e12},
        {"render.footprint", (double)d->render.footprint, 0, GSF_FOOTPRINT_OFFICIAL},
        {"render.gradient", (double)d->render.gradient, 0, GSF_GRADIENT_OFFICIAL},
        {"render.antialiased", (double)d->render.antialiased, -INFINITY, INFINITY},
        {"render.near_plane", (double)d->render.near_plane, 0, 1e30},
        {"dropout", (double)d->dropout, 0, 0.9},
        {"opacity_decay", (double)d->opacity_decay, 0, 0.5},
        {"scale_penalty", (double)d->scale_penalty, 0, 1e6},
        {"opacity_penalty", (double)d->opacity_penalty, 0, 1e6},
        {"depth_smoothness", (double)d->depth_smoothness, 0, 1e6},
        {"sharpness", (double)d->sharpness, 0, 1e3},
        {"sharpness_from", (double)d->sharpness_from, 0, 1e9},
        {"lazy_adam", (double)d->lazy_adam, 0, 1},
    };
    memcpy(out, fields, sizeof fields);
}

static gsf_result gsf__train_desc_check(gsf_context* ctx, const gsf_train_desc* d) {
    gsf__field fields[GSF__TRAIN_FIELDS];
    gsf__train_fields(d, fields);
    GSF__TRY(gsf__check_fields(ctx, "train desc", fields, GSF__TRAIN_FIELDS));
    if (d->render.hidden || d->render.sh_bands || (d->render.opacity_scale != 0.0f && d->render.opacity_scale != 1.0f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "train desc: render.hidden, sh_bands and opacity_scale are set by the trainer");
    return GSF_OK;
}

static gsf_result gsf__check_train_canaries(gsf_context* ctx, const gsf_train_desc* desc) {
    GSF__CHECK_CANARIES(ctx, "train", desc);
    GSF__CHECK_CANARIES(ctx, "train.render", &desc->render);
    return GSF_OK;
}

static int gsf__all_finite(const float* v, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (!(fabsf(v[i]) <= FLT_MAX)) return 0;
    return 1;
}

// Copies the initial splats. Those with a non-finite value are dropped and counted in trainer->rejected.
static gsf_result gsf__trainer_take_splats(gsf_context* ctx, gsf_trainer* trainer, const gsf_splats* initial) {
    if (!initial || initial->sh_degree < 0 || initial->sh_degree > 3)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "trainer: no initial splats");
    for (int a = 0; a < 3; a++)
        if (!isfinite(initial->origin[a]))
            return gsf_fail(ctx, GSF_ERROR_NUMERIC, "trainer: origin of the splats is not finite");
    gsf__model* model = &trainer->model;
    model->sh_degree = trainer->desc.sh_degree ? trainer->desc.sh_degree : initial->sh_degree;
    GSF__TRY(gsf__model_reserve(ctx, model, initial->count));
    const size_t from_sh = 3 * (size_t)gsf_splat_count_sh(initial->sh_degree);
    const float* from[GSF__GROUPS] = {initial->means, initial->log_scales, initial->quats, initial->opacity_logits,
                                      initial->sh};
    size_t used_sh = 3; // floats of an SH row up to the last one that is non-zero in any splat
    for (size_t i = 0; i < initial->count; i++) {
        int finite = 1;
        for (int g = 0; g < GSF__GROUPS; g++) {
            const size_t width = g == GSF__SH ? from_sh : model->groups[g].width;
            finite = finite && gsf__all_finite(from[g] + i * width, width);
        }
        if (!finite) {
            trainer->rejected++;
            continue;
        }
        for (int g = 0; g < GSF__GROUPS; g++) {
            const size_t from_width = g == GSF__SH ? from_sh : model->groups[g].width, to_width = model->groups[g].width;
            const size_t width = from_width < to_width ? from_width : to_width;
            memcpy(model->groups[g].value + model->count * to_width, from[g] + i * from_width, width * sizeof(float));
            if (g != GSF__SH) continue;
            for (size_t k = used_sh; k < width; k++)
                if (from[g][i * from_width + k] != 0.0f) used_sh = k + 1;
        }
        const uint32_t id = initial->ids ? initial->ids[i] : (uint32_t)i;
        if (id >= UINT32_MAX / 2)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "trainer: splat id %u leaves no room for new ids", id);
        if (id >= model->next_id) model->next_id = id + 1;
        model->ids[model->count++] = id;
    }
    if (model->count == 0)
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "trainer: none of %zu initial splats can be used", initial->count);
    if (trainer->rejected)
        gsf_log(ctx, GSF_LOG_WARNING, "trainer: %zu initial splats with a non-finite value dropped", trainer->rejected);
    for (trainer->first_bands = 1; 3 * (size_t)trainer->first_bands * (size_t)trainer->first_bands < used_sh;)
        trainer->first_bands++;
    memcpy(trainer->view.origin, initial->origin, sizeof initial->origin);
    return GSF_OK;
}

static void gsf__trainer_refresh_view(gsf_trainer* trainer) {
    const gsf__model* model = &trainer->model;
    trainer->view.count = model->count;
    trainer->view.sh_degree = model->sh_degree;
    trainer->view.means = model->groups[GSF__MEANS].value;
    trainer->view.log_scales = model->groups[GSF__SCALES].value;
    trainer->view.quats = model->groups[GSF__QUATS].value;
    trainer->view.opacity_logits = model->groups[GSF__OPACITY].value;
    trainer->view.sh = model->groups[GSF__SH].value;
    trainer->view.ids = model->ids;
}

// Median depth of the splats in front of the training cameras, from a sample of both; 0 if there are no such splats.
static gsf_result gsf__trainer_median_depth(gsf_context* ctx, const gsf_trainer* trainer, double* out) {
    const gsf__model* model = &trainer->model;
    const size_t step = model->count / 2048 + 1, per_view = (model->count + step - 1) / step;
    const size_t view_step = trainer->photos.count / 64 + 1;
    float* depths = (float*)gsf_alloc(ctx, per_view * (trainer->photos.count / view_step + 1), sizeof(float));
    if (!depths) return GSF_ERROR_OUT_OF_MEMORY;
    size_t count = 0;
    for (size_t v = 0; v < trainer->photos.count; v += view_step)
        for (size_t i = 0; i < model->count; i += step) {
            const float* mean = model->groups[GSF__MEANS].value + 3 * i;
            double world[3], p[3];
            for (int a = 0; a < 3; a++) world[a] = trainer->view.origin[a] + (double)mean[a];
            gsf__camera_transform(&trainer->photos.photos[v].camera, world, p);
            if (p[2] > 0.0 && p[2] <= (double)FLT_MAX) depths[count++] = (float)p[2];
        }
    uint32_t low = 0, high = 0x7f800000u; // bisection over bit patterns, ordered like positive floats
    while (low < high) {
        const uint32_t middle = low + (high - low) / 2;
        size_t below = 0;
        for (size_t i = 0; i < count; i++) below += depths[i] <= gsf__positive_float(middle);
        if (2 * below >= count) high = middle;
        else low = middle + 1;
    }
    *out = count ? (double)gsf__positive_float(low) : 0.0;
    gsf_free(ctx, depths);
    return GSF_OK;
}

// Largest distance of a camera centre from their mean. `stride`: bytes from one camera to the next.
static double gsf__camera_spread(const gsf_camera* cameras, size_t stride, size_t count) {
    double mean[3] = {0.0, 0.0, 0.0}, first[3] = {0.0, 0.0, 0.0}, largest = 0.0;
    for (int pass = 0; pass < 2; pass++)
        for (size_t i = 0; i < count; i++) {
            double c[3], d2 = 0.0;
            gsf_get_camera_center((const gsf_camera*)(const void*)((const char*)cameras + i * stride), c);
            if (pass == 0 && i == 0) memcpy(first, c, sizeof first); // relative to it, large coordinates stay precise
            for (int a = 0; a < 3; a++) {
                if (pass == 0) mean[a] += (c[a] - first[a]) / (double)count;
                d2 += (c[a] - first[a] - mean[a]) * (c[a] - first[a] - mean[a]);
            }
            if (pass == 1 && sqrt(d2) > largest) largest = sqrt(d2);
        }
    return largest;
}

// Sets desc.extent to 1.1 times the largest distance of a camera from their mean. If that is (nearly) zero, as for a
// single camera, uses the median depth of the initial splats instead, or 1 if no splat is in front of a camera.
static gsf_result gsf__trainer_find_extent(gsf_context* ctx, gsf_trainer* trainer) {
    const gsf__photo_set* set = &trainer->photos;
    double median = 0.0;
    GSF__TRY(gsf__trainer_median_depth(ctx, trainer, &median));
    double extent = 1.1 * gsf__camera_spread(&set->photos->camera, sizeof *set->photos, set->count);
    if (!(extent > 1e-6 * median) || extent < 1e-20) extent = median > 1e-20 ? median : 1.0;
    trainer->desc.extent = extent < 1e30 ? (float)extent : 1e30f;
    return GSF_OK;
}

static gsf_result gsf__trainer_reserve_images(gsf_context* ctx, gsf_trainer* trainer, const gsf__photo_set* set) {
    if (set->count == 0) return GSF_OK;
    const size_t pixels = (size_t)set->max_width * (size_t)set->max_height;
    GSF__TRY(gsf__reserve(ctx, (void**)&trainer->color, &trainer->color_capacity, 0, pixels, 3 * sizeof(float)));
    GSF__TRY(gsf__reserve(ctx, (void**)&trainer->d_color, &trainer->d_color_capacity, 0, pixels, 3 * sizeof(float)));
    if (trainer->desc.depth_smoothness > 0.0f) {
        GSF__TRY(gsf__reserve(ctx, (void**)&trainer->depth, &trainer->depth_capacity, 0, pixels, sizeof(float)));
        GSF__TRY(gsf__reserve(ctx, (void**)&trainer->d_depth, &trainer->d_depth_capacity, 0, pixels, sizeof(float)));
    }
    return gsf__loss_reserve(ctx, &trainer->loss, set->max_width, set->max_height);
}

// Number of SH bands trained in an iteration: one more every sh_interval, but never fewer than the initial splats use.
static int32_t gsf__trainer_bands(const gsf_trainer* trainer, int32_t iteration) {
    const int32_t grown = iteration / trainer->desc.sh_interval + 1, all = trainer->model.sh_degree + 1;
    const int32_t bands = grown > trainer->first_bands ? grown : trainer->first_bands;
    return bands < all ? bands : all;
}

static gsf__adam_rates gsf__trainer_rates(const gsf_trainer* trainer, int32_t iteration) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__adam_rates rates;
    rates.means = 0.0;
    if (d->lr_means > 0.0f)
        rates.means = gsf__exponential_rate(iteration, (double)d->lr_means * (double)d->extent,
                                            (double)d->lr_means_final * (double)d->extent, d->lr_means_delay_steps,
                                            (double)d->lr_means_delay, d->iterations);
    rates.scales = (double)d->lr_scales;
    rates.quats = (double)d->lr_quats;
    rates.opacity = (double)d->lr_opacity;
    rates.sh_dc = (double)d->lr_sh_dc;
    rates.sh_rest = (double)d->lr_sh_rest;
    return rates;
}

static void gsf__trainer_prepare_lazy(const gsf_context* ctx, gsf_trainer* trainer) { // for steps taken so far
    const gsf__adam_rates rates = gsf__trainer_rates(trainer, trainer->iteration);
    gsf__lazy_prepare(ctx->cpu_level, &trainer->lazy, &trainer->model, &rates, trainer->iteration,
                      gsf__trainer_bands(trainer, trainer->iteration));
}

// The grey of the photos' mean over pixels, by their weights, and channels; black if all weights are 0. Not the mean colour:
// splats that may be half transparent before a backdrop of their own hue explain the photos with worse geometry.
static float gsf__photo_set_grey(const gsf__photo_set* set) {
    double sum = 0.0, total = 0.0;
    for (size_t p = 0; p < set->count; p++) {
        const gsf__target* t = &set->photos[p].target;
        for (size_t i = 0; i < (size_t)t->width * (size_t)t->height; i++) {
            const double w = t->weight ? (double)t->weight[i] : 1.0;
            total += 3.0 * w;
            for (size_t c = 0; c < 3; c++) sum += w * (t->u8 ? (double)t->u8[3 * i + c] / 255.0 : (double)t->f32[3 * i + c]);
        }
    }
    const double mean = total > 0.0 ? sum / total : 0.0;
    return (float)(mean < 0.0 ? 0.0 : mean > 1.0 ? 1.0 : mean);
}

static gsf_result gsf__trainer_setup(gsf_context* ctx, gsf_trainer* trainer, const gsf_train_view* views,
                                     size_t view_count, const gsf_splats* initial) {
    const int near_given = trainer->desc.render.near_plane != 0.0f;
    GSF__TRY(gsf__train_desc_check(ctx, &trainer->desc));
    if (view_count == 0) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "trainer: no training view");
    GSF__TRY(gsf__photo_set_make(ctx, views, view_count, "view", &trainer->photos));
    if (trainer->desc.coarse_until > 0) GSF__TRY(gsf__photo_set_halve(ctx, &trainer->photos, &trainer->coarse));
    if (trainer->desc.background_kind == GSF_BACKGROUND_PHOTOS) {
        const float grey = gsf__photo_set_grey(&trainer->photos);
        for (int c = 0; c < 3; c++) trainer->desc.background[c] = grey;
    }
    memcpy(trainer->desc.render.background, trainer->desc.background, sizeof trainer->desc.background);
    memcpy(trainer->view.background, trainer->desc.background, sizeof trainer->view.background);
    GSF__TRY(gsf__trainer_take_splats(ctx, trainer, initial));
    if (trainer->desc.extent == 0.0f) GSF__TRY(gsf__trainer_find_extent(ctx, trainer));
    if (!near_given) {
        const float near_plane = 0.01f * trainer->desc.extent;
        trainer->desc.render.near_plane = near_plane < 0.2f ? near_plane : 0.2f;
    }
    GSF__TRY(gsf__trainer_reserve_images(ctx, trainer, &trainer->photos));
    gsf__trainer_refresh_view(trainer);
    gsf__trainer_prepare_lazy(ctx, trainer);
    if (trainer->desc.lazy_adam) trainer->model.lazy = &trainer->lazy;
    return gsf_splat_make_rasterizer(ctx, &trainer->rasterizer);
}

// Hides a random share of the splats in a render. The choice depends only on seed, stream and splat id.
typedef struct gsf__dropout_job {
    const gsf__model* model;
    uint64_t seed, stream;
    double share;
} gsf__dropout_job;

static void gsf__dropout_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__dropout_job* job = (const gsf__dropout_job*)arg;
    const gsf__model* model = job->model;
    (void)worker;
    const size_t end = gsf__model_chunk_end(model->count, chunk);
    for (size_t i = chunk * GSF__MODEL_CHUNK; i < end; i++)
        model->hidden[i] = gsf_draw_uniform(job->seed, job->stream, model->ids[i]) < job->share;
}

// Adds this step's screen-space gradients to the densification statistics and zeroes them.
typedef struct gsf__visit_job {
    gsf__model* model;
    int counts[2];           // [0] photo, [1] restored view: is it counted in this step?
    float half[2][2];        // half width and height of each
} gsf__visit_job;

// What the visit adds to the splat's gradient sum.
static float gsf__visit_grad(const gsf__visit_job* job, int k, size_t i) {
    const float* g = job->model->screen[k] + 2 * i;
    const float x = g[0] * job->half[k][0], y = g[1] * job->half[k][1], norm = sqrtf(x * x + y * y);
    return norm <= FLT_MAX ? norm : 0.0f;
}

// The number of splats whose mean gradient will reach the threshold after the visit.
static size_t gsf__visit_candidates(const gsf__visit_job* job, float threshold) {
    const gsf__model* model = job->model;
    size_t count = 0;
    for (size_t i = 0; i < model->count; i++) {
        int reached = 0;
        for (int k = 0; k < 2; k++) {
            const int seen = job->counts[k] && model->seen[k][i];
            const float sum = seen ? model->grad_sum[k][i] + gsf__visit_grad(job, k, i) : model->grad_sum[k][i];
            reached |= gsf__densify_mean(sum, model->visits[k][i] + (seen ? 1u : 0u)) >= threshold;
        }
        count += (size_t)reached;
    }
    return count;
}

static void gsf__visit_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__visit_job* job = (const gsf__visit_job*)arg;
    gsf__model* model = job->model;
    (void)worker;
    const size_t end = gsf__model_chunk_end(model->count, chunk);
    for (int k = 0; k < 2; k++) {
        if (!job->counts[k]) continue;
        for (size_t i = chunk * GSF__MODEL_CHUNK; i < end; i++) {
            float* g = model->screen[k] + 2 * i;
            if (model->seen[k][i]) {
                model->grad_sum[k][i] += gsf__visit_grad(job, k, i);
                model->visits[k][i]++;
            }
            g[0] = g[1] = 0.0f;
        }
    }
}

// Adds the gradients of weight * mean(exp(log_scale)) / extent and of weight * mean(opacity).
typedef struct gsf__penalty_job {
    gsf__model* model;
    float scale;   // weight / (3 count extent); 0 = off
    float opacity; // weight / count; 0 = off
} gsf__penalty_job;

static void gsf__penalty_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__penalty_job* job = (const gsf__penalty_job*)arg;
    const gsf__group *scales = &job->model->groups[GSF__SCALES], *logits = &job->model->groups[GSF__OPACITY];
    (void)worker;
    const size_t begin = chunk * GSF__MODEL_CHUNK, end = gsf__model_chunk_end(job->model->count, chunk);
    for (size_t i = 3 * begin; job->scale > 0.0f && i < 3 * end; i++)
        scales->grad[i] += job->scale * gsf__exp(scales->value[i] < 80.0f ? scales->value[i] : 80.0f);
    for (size_t i = begin; job->opacity > 0.0f && i < end; i++)
        logits->grad[i] += job->opacity * gsf__sigmoid(logits->value[i]) * gsf__sigmoid(-logits->value[i]);
}

/* MCMC perturbs the means by covariance * standard normal noise * rate, with a factor that vanishes for opaque splats.
   The rate of the authors' code, noise * lr_means * extent, depends on the unit of length. Dividing it by extent^2
   makes the noise the same in every unit, equal to that of a scene of extent 1, the size to which gsplat normalises
   scenes. */
typedef struct gsf__noise_job {
    gsf__model* model;
    uint64_t seed, stream;
    double rate;
} gsf__noise_job;

static void gsf__noise_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__noise_job* job = (const gsf__noise_job*)arg;
    const gsf__model* model = job->model;
    (void)worker;
    const size_t end = gsf__model_chunk_end(model->count, chunk);
    for (size_t i = chunk * GSF__MODEL_CHUNK; i < end; i++) {
        const float steep = 100.0f * (0.005f - gsf__sigmoid(model->groups[GSF__OPACITY].value[i]));
        if (steep < -30.0f) continue; // opacity above 0.305: the factor is below 1e-13
        float* mean = model->groups[GSF__MEANS].value + 3 * i;
        const float* scale = model->groups[GSF__SCALES].value + 3 * i;
        double r[9], normal[3], axis[3];
        gsf__densify_rotation(model->groups[GSF__QUATS].value + 4 * i, r);
        for (size_t a = 0; a < 3; a++)
            normal[a] = gsf_draw_normal(job->seed, job->stream, (uint64_t)model->ids[i] * 3 + a);
        for (int a = 0; a < 3; a++) {
            const double variance = (double)gsf__exp(scale[a] < 40.0f ? 2.0f * scale[a] : 80.0f);
            axis[a] = variance * (r[a] * normal[0] + r[3 + a] * normal[1] + r[6 + a] * normal[2]);
        }
        const double amount = job->rate * (double)gsf__sigmoid(steep);
        for (int a = 0; a < 3; a++) {
            const double moved = (double)mean[a] +
                                 amount * (r[3 * a] * axis[0] + r[3 * a + 1] * axis[1] + r[3 * a + 2] * axis[2]);
            if (fabs(moved) <= (double)FLT_MAX) mean[a] = (float)moved;
        }
    }
}

// Multiplies every opacity by f = `factor`. In logits: logit' = log(f / (1 + e - f)), where e = exp(-logit).
typedef struct gsf__decay_job {
    gsf__model* model;
    double factor;
} gsf__decay_job;

static void gsf__decay_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__decay_job* job = (const gsf__decay_job*)arg;
    float* logits = job->model->groups[GSF__OPACITY].value;
    (void)worker;
    const size_t count = job->model->count;
    const size_t end = gsf__model_chunk_end(count, chunk);
    for (size_t i = chunk * GSF__MODEL_CHUNK; i < end; i++)
        if (logits[i] > -30.0f) // lower ones are invisible anyway
            logits[i] = (float)(gsf__log_f64(job->factor) - gsf__log_f64(gsf__exp_f64(-(double)logits[i]) + 1.0 - job->factor));
}

static int gsf__trainer_densifies(const gsf_trainer* trainer, int32_t iteration) { // are gradient statistics needed?
    return !trainer->desc.mcmc && iteration < trainer->desc.densify_until;
}

/* Returns the splats with all SH up to date, for use outside of a step. This must not change the model, or the rounding
   of a run would depend on when its splats were read. So the up-to-date SH are written to the SH gradients, which are
   zero between steps; gsf__trainer_hide zeroes them again. ctx NULL: runs on the calling thread. */
static const gsf_splats* gsf__trainer_show(gsf_context* ctx, gsf_trainer* trainer) {
    gsf__model* model = &trainer->model;
    if (!model->lazy) return &trainer->view;
    if (trainer->shows) return &trainer->shown;
    const size_t chunks = gsf__model_chunks(model->count);
    if (ctx) gsf__parallel_for(ctx, chunks, gsf__lazy_show_chunk, model->lazy);
    for (size_t i = 0; !ctx && i < chunks; i++) gsf__lazy_show_chunk(model->lazy, i, 0);
    trainer->shown = trainer->view;
    trainer->shown.sh = model->groups[GSF__SH].grad;
    trainer->shows = 1;
    return &trainer->shown;
}

static void gsf__trainer_hide(gsf_trainer* trainer) { // ends gsf__trainer_show; call before computing gradients
    const gsf__group* sh = &trainer->model.groups[GSF__SH];
    if (trainer->shows && trainer->model.count) memset(sh->grad, 0, trainer->model.count * sh->width * sizeof(float));
    trainer->shows = 0;
}

// Renders a photo's view and adds the gradient of its loss, times `scale`. which: 0 photo, 1 restored view.
static gsf_result gsf__trainer_pass(gsf_context* ctx, gsf_trainer* trainer, gsf__photo* photo, int which, int32_t iteration,
                                    float scale, gsf__loss_value* value) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__model* model = &trainer->model;
    gsf_render_desc render = d->render;
    render.sh_bands = gsf__trainer_bands(trainer, iteration);
    const double share = (double)d->dropout * iteration / d->iterations;
    if (share > 0.0) {
        gsf__dropout_job job;
        job.model = model;
        job.seed = d->seed;
        job.stream = gsf__stream(which ? GSF__STREAM_DROPOUT_RESTORED : GSF__STREAM_DROPOUT, (uint64_t)iteration);
        job.share = share;
        gsf__parallel_for(ctx, gsf__model_chunks(model->count), gsf__dropout_chunk, &job);
        render.hidden = model->hidden;
        render.opacity_scale = (float)(1.0 / (1.0 - share));
    }
    for (uint64_t c = 0; c < 3 && d->background_kind == GSF_BACKGROUND_RANDOM; c++)
        render.background[c] = (float)gsf_draw_uniform(d->seed, gsf__stream(GSF__STREAM_BACKGROUND, (uint64_t)iteration),
                                                       3 * (uint64_t)which + c);
    const int32_t width = photo->camera.width, height = photo->camera.height;
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.color = gsf_wrap_image(trainer->color, GSF_F32, width, height, 3);
    const int smooth = d->depth_smoothness > 0.0f;
    if (smooth) out.depth = gsf_wrap_image(trainer->depth, GSF_F32, width, height, 1);
    trainer->rasterizer->wake = model->lazy ? gsf__lazy_wake : NULL;
    trainer->rasterizer->wake_user = model->lazy;
    const gsf_result rendered = gsf_splat_render(ctx, trainer->rasterizer, &trainer->view, &photo->camera, &render, &out);
    trainer->rasterizer->wake = NULL;
    if (rendered != GSF_OK) return rendered;
    GSF__TRY(gsf__loss(ctx, &trainer->loss, &photo->target, trainer->color, d->lambda_ssim, scale, trainer->d_color,
                       value));
    if (smooth)
        (void)gsf__depth_smoothness(ctx, &trainer->loss, &photo->target, trainer->depth, d->extent,
                                    scale * d->depth_smoothness, trainer->d_depth);
    gsf_splat_grads grads;
    memset(&grads, 0, sizeof grads);
    grads.means = model->groups[GSF__MEANS].grad;
    grads.log_scales = model->groups[GSF__SCALES].grad;
    grads.quats = model->groups[GSF__QUATS].grad;
    grads.opacity_logits = model->groups[GSF__OPACITY].grad;
    grads.sh = model->groups[GSF__SH].grad;
    const int densifies = gsf__trainer_densifies(trainer, iteration);
    if (densifies && d->densify_absolute) grads.means2d_abs = model->screen[which];
    else if (densifies) grads.means2d = model->screen[which];
    GSF__TRY(gsf_splat_render_backward(ctx, trainer->rasterizer, &trainer->view, &photo->camera, &render,
                                       trainer->d_color, smooth ? trainer->d_depth : NULL, NULL, &grads));
    const int32_t* radii = trainer->rasterizer->radii;
    for (size_t i = 0; densifies && i < model->count; i++) model->seen[which][i] = radii[i] > 0;
    return GSF_OK;
}

static gsf__densify_rule gsf__trainer_rule(const gsf_trainer* trainer, int32_t iteration) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.grad = d->densify_grad;
    rule.clone_scale = (double)d->densify_scale * (double)d->extent;
    rule.prune_opacity = (double)d->prune_opacity;
    if (d->opacity_reset_interval > 0 && iteration > d->opacity_reset_interval)
        rule.prune_scale = (double)d->prune_scale * (double)d->extent;
    rule.max_splats = d->max_splats;
    rule.shared = d->densify_shared;
    rule.seed = d->seed;
    rule.stream = gsf__stream(GSF__STREAM_SPLIT, (uint64_t)iteration);
    return rule;
}

// Adds the gradients of this step's photo and restored view, times `share`.
static gsf_result gsf__trainer_accumulate(gsf_context* ctx, gsf_trainer* trainer, int32_t iteration, float share,
                                          gsf__visit_job* visits, gsf_train_stats* stats) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__photo* photos[2] = {NULL, NULL};
    photos[0] = gsf__photo_at(&trainer->photos, d->seed, GSF__STREAM_PHOTOS, (uint64_t)iteration - 1);
    if (trainer->coarse.count && iteration <= d->coarse_until)
        photos[0] = trainer->coarse.photos + (photos[0] - trainer->photos.photos);
    if (trainer->restored.count && trainer->restored_weight > 0.0f)
        photos[1] = gsf__photo_at(&trainer->restored, d->seed, GSF__STREAM_RESTORED, trainer->restored_steps);
    for (int k = 0; k < 2; k++) {
        if (!photos[k]) continue;
        gsf__loss_value value;
        const float scale = k ? share * trainer->restored_weight : share;
        GSF__TRY(gsf__trainer_pass(ctx, trainer, photos[k], k, iteration, scale, &value));
        if (k == 0) {
            stats->loss = value.total;
            stats->l1 = value.l1;
            stats->ssim = value.ssim;
        } else {
            stats->restored_loss = value.total;
        }
        visits->counts[k] = gsf__trainer_densifies(trainer, iteration);
        visits->half[k][0] = 0.5f * (float)photos[k]->camera.width;
        visits->half[k][1] = 0.5f * (float)photos[k]->camera.height;
    }
    return GSF_OK;
}

// Moves the means up the loss, as far as `radius` pixels at their depth. What is behind the camera stays.
typedef struct gsf__sharp_job {
    gsf__model* model;
    const gsf_camera* camera;
    const double* origin;
    double radius;
} gsf__sharp_job;

static void gsf__sharp_chunk(void* arg, size_t chunk, int32_t worker) {
    const gsf__sharp_job* job = (const gsf__sharp_job*)arg;
    const gsf__group* means = &job->model->groups[GSF__MEANS];
    (void)worker;
    const size_t end = gsf__model_chunk_end(job->model->count, chunk);
    for (size_t i = chunk * GSF__MODEL_CHUNK; i < end; i++) {
        const float* slope = means->grad + 3 * i;
        double world[3], p[3], square = 0.0;
        for (int a = 0; a < 3; a++) {
            world[a] = job->origin[a] + (double)means->value[3 * i + (size_t)a];
            square += (double)slope[a] * (double)slope[a];
        }
        gsf__camera_transform(job->camera, world, p);
        if (!(square > 0.0 && square < (double)INFINITY && p[2] > 0.0)) continue;
        const double step = job->radius * p[2] / (job->camera->fx * sqrt(square));
        for (int a = 0; a < 3; a++) {
            const double moved = (double)means->value[3 * i + (size_t)a] + step * (double)slope[a];
            if (fabs(moved) <= (double)FLT_MAX) means->value[3 * i + (size_t)a] = (float)moved;
        }
    }
}

// The part of a step that can fail: accumulates the gradients in the model. On failure, nothing else has changed.
static gsf_result gsf__trainer_gradients(gsf_context* ctx, gsf_trainer* trainer, int32_t iteration,
                                         gsf__visit_job* visits, gsf_train_stats* stats) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__model* model = &trainer->model;
    const int sharp = d->sharpness > 0.0f && iteration > d->sharpness_from && model->count > 0;
    if (sharp)
        GSF__TRY(gsf__reserve(ctx, (void**)&trainer->means, &trainer->means_capacity, 0, model->count, 3 * sizeof(float)));
    GSF__TRY(gsf__trainer_accumulate(ctx, trainer, iteration, sharp ? 0.5f : 1.0f, visits, stats));
    if (!sharp) return GSF_OK;
    const gsf__photo* photo = gsf__photo_at(&trainer->photos, d->seed, GSF__STREAM_PHOTOS, (uint64_t)iteration - 1);
    gsf__sharp_job job = {model, &photo->camera, trainer->view.origin, (double)d->sharpness};
    gsf_train_stats ignored;
    memcpy(trainer->means, model->groups[GSF__MEANS].value, 3 * model->count * sizeof(float));
    gsf__parallel_for(ctx, gsf__model_chunks(model->count), gsf__sharp_chunk, &job);
    const gsf_result result = gsf__trainer_accumulate(ctx, trainer, iteration, 0.5f, visits, &ignored);
    memcpy(model->groups[GSF__MEANS].value, trainer->means, 3 * model->count * sizeof(float));
    return result;
}

static void gsf__trainer_clear_gradients(gsf_trainer* trainer) {
    gsf__model* model = &trainer->model;
    for (int g = 0; g < GSF__GROUPS; g++)
        memset(model->groups[g].grad, 0, model->count * model->groups[g].width * sizeof(float));
    for (int k = 0; k < 2; k++) memset(model->screen[k], 0, 2 * model->count * sizeof(float));
    for (size_t b = 0; b < gsf__model_blocks(model->count); b++)
        if (model->rest[b] == GSF__AWAKE) model->rest[b] = 0;
}

static void gsf__trainer_update(gsf_context* ctx, gsf_trainer* trainer, int32_t iteration) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__model* model = &trainer->model;
    const size_t chunks = gsf__model_chunks(model->count);
    if (d->scale_penalty > 0.0f || d->opacity_penalty > 0.0f) {
        gsf__penalty_job job;
        job.model = model;
        job.scale = (float)((double)d->scale_penalty / (3.0 * (double)model->count * (double)d->extent));
        job.opacity = (float)((double)d->opacity_penalty / (double)model->count);
        gsf__parallel_for(ctx, chunks, gsf__penalty_chunk, &job);
    }
    const gsf__adam_rates rates = gsf__trainer_rates(trainer, iteration);
    trainer->rejected += gsf__adam_step(ctx, model, &rates, iteration, gsf__trainer_bands(trainer, iteration));
    if (d->opacity_decay > 0.0f && iteration % GSF__DECAY_INTERVAL == 0) {
        gsf__decay_job job;
        job.model = model;
        job.factor = gsf__power_f64(1.0 - (double)d->opacity_decay, GSF__DECAY_INTERVAL);
        gsf__parallel_for(ctx, chunks, gsf__decay_chunk, &job);
    }
    if (d->mcmc && d->mcmc_noise > 0.0f) {
        gsf__noise_job job;
        job.model = model;
        job.seed = d->seed;
        job.stream = gsf__stream(GSF__STREAM_NOISE, (uint64_t)iteration);
        job.rate = (double)d->mcmc_noise * rates.means / ((double)d->extent * (double)d->extent);
        gsf__parallel_for(ctx, chunks, gsf__noise_chunk, &job);
    }
}

GSF_API gsf_result gsf_splat_step_trainer(gsf_context* ctx, gsf_trainer* trainer, gsf_train_stats* stats) {
    const gsf_train_desc* d = &trainer->desc;
    gsf__model* model = &trainer->model;
    gsf_train_stats local;
    memset(&local, 0, sizeof local);
    if (stats) *stats = local;
    if (trainer->iteration >= d->iterations)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "trainer: all %d iterations are done", (int)d->iterations);
    GSF__TRY(gsf__check_cancel(ctx));

    gsf__trainer_hide(trainer);
    const int32_t iteration = trainer->iteration + 1;
    gsf__visit_job visits;
    memset(&visits, 0, sizeof visits);
    visits.model = model;
    const int densify = iteration < d->densify_until && iteration > d->densify_from &&
                        iteration % d->densify_interval == 0;
    gsf_result result = gsf__trainer_gradients(ctx, trainer, iteration, &visits, &local);
    if (result == GSF_OK && densify) { // reserve now: nothing may fail after Adam, which decides between clone and split
        const size_t room = d->max_splats > model->count ? d->max_splats - model->count : 0;
        const size_t found = d->mcmc ? 0 : gsf__visit_candidates(&visits, gsf__trainer_rule(trainer, iteration).grad);
        const size_t grown = d->mcmc ? gsf__mcmc_growth(model->count, d->max_splats) : 2 * (room < found ? room : found);
        result = gsf__model_reserve(ctx, model, model->count + grown);
        gsf__trainer_refresh_view(trainer);
    }
    if (result != GSF_OK) {
        gsf__trainer_clear_gradients(trainer);
        return result;
    }

    gsf__parallel_for(ctx, gsf__model_chunks(model->count), gsf__visit_chunk, &visits);
    gsf__trainer_update(ctx, trainer, iteration);
    if (densify) {
        if (model->lazy) gsf__parallel_for(ctx, gsf__model_chunks(model->count), gsf__lazy_all_chunk, model->lazy);
        const gsf__densify_rule rule = gsf__trainer_rule(trainer, iteration);
        if (d->mcmc) {
            gsf__mcmc_densify(model, &rule);
        } else {
            size_t clones, splits;
            gsf__densify_select(model, &rule, &clones, &splits);
            gsf__densify_apply(model, &rule, clones, splits);
        }
    }
    if (gsf__trainer_densifies(trainer, iteration) && d->opacity_reset_interval > 0 &&
        iteration % d->opacity_reset_interval == 0)
        gsf__reset_opacity(model, 0.01);
    gsf__trainer_refresh_view(trainer);
    if (trainer->restored.count && trainer->restored_weight > 0.0f) trainer->restored_steps++;
    trainer->iteration = iteration;
    local.iteration = iteration;
    local.splats = model->count;
    local.rejected = trainer->rejected;
    if (stats) *stats = local;
    return GSF_OK;
}

// A checkpoint holds, as chunks:
//     "TRNR"                                   u32 byte order mark 0x01020304 in native order; then, little-endian:
//                                              u32 iteration, SH degree, next id, first bands; f32 restored weight;
//                                              u64 splats, restored steps, rejected, settings; f64 origin (3)
//     "TV0 ".."TV4 ", "TM0 "..., "TS0 "...     value, first and second moment of means, log scales, quaternions,
//                                              opacity logits, SH; native byte order, like the following
//     "TIDS"                                   ids
//     "TGRD", "TVIS", "TGRR", "TVIR"           gradient sums and visits for densification: photos, restored views
//     "TRST"                                   u8 per block of 32 splats: Adam steps that its SH have skipped
enum { GSF__STATE_SIZE = 24 + 4 * 8 + 3 * 8 };
#define GSF__BYTE_ORDER_MARK 0x01020304u

// Hash of the settings and the number of photos, to detect that a run is continued with different ones.
static uint64_t gsf__trainer_settings(const gsf_trainer* trainer) {
    gsf__field fields[GSF__TRAIN_FIELDS];
    gsf__train_fields(&trainer->desc, fields);
    uint64_t hash = trainer->photos.count;
    for (size_t i = 0; i < GSF__TRAIN_FIELDS; i++) {
        uint64_t bits;
        memcpy(&bits, &fields[i].value, sizeof bits);
        hash = gsf_draw_bits(hash, bits, i);
    }
    return hash;
}

static const char gsf__column_tags[GSF__SAVED_COLUMNS][5] = {
    "TV0 ", "TV1 ", "TV2 ", "TV3 ", "TV4 ", "TM0 ", "TM1 ", "TM2 ", "TM3 ", "TM4 ",
    "TS0 ", "TS1 ", "TS2 ", "TS3 ", "TS4 ", "TIDS", "TGRD", "TVIS", "TGRR", "TVIR"};

// Makes room for the trainer's chunks and `more` bytes at once: a buffer that grows step by step is there twice each time.
// There is some left for what the caller appends; memory that is not touched takes no space.
static void gsf__trainer_reserve_chunks(gsf_context* ctx, const gsf_trainer* trainer, size_t more, gsf_buffer* chunks) {
    const gsf__model* model = &trainer->model;
    gsf__column columns[GSF__COLUMNS];
    gsf__model_columns(model, columns);
    size_t bytes = more + GSF__STATE_SIZE + gsf__model_blocks(model->count) + (size_t)(GSF__SAVED_COLUMNS + 3) * 32;
    for (int k = 0; k < GSF__SAVED_COLUMNS; k++) bytes += model->count * columns[k].row;
    if (!chunks->failed && gsf__reserve(ctx, (void**)&chunks->data, &chunks->capacity, chunks->size,
                                        chunks->size + bytes + bytes / 16 + 4096, 1) != GSF_OK)
        chunks->failed = 1;
}

GSF_API void gsf_splat_format_trainer(gsf_context* ctx, const gsf_trainer* trainer, gsf_buffer* chunks) {
    const gsf__model* model = &trainer->model;
    gsf__trainer_reserve_chunks(ctx, trainer, 0, chunks);
    char state[GSF__STATE_SIZE];
    const uint32_t mark = GSF__BYTE_ORDER_MARK;
    uint32_t weight;
    memcpy(state, &mark, 4);
    memcpy(&weight, &trainer->restored_weight, 4);
    gsf__store_le(state + 4, (uint64_t)trainer->iteration, 4);
    gsf__store_le(state + 8, (uint64_t)model->sh_degree, 4);
    gsf__store_le(state + 12, model->next_id, 4);
    gsf__store_le(state + 16, (uint64_t)trainer->first_bands, 4);
    gsf__store_le(state + 20, weight, 4);
    gsf__store_le(state + 24, model->count, 8);
    gsf__store_le(state + 32, trainer->restored_steps, 8);
    gsf__store_le(state + 40, trainer->rejected, 8);
    gsf__store_le(state + 48, gsf__trainer_settings(trainer), 8);
    for (int a = 0; a < 3; a++) gsf__store_f64(state + 56 + 8 * a, trainer->view.origin[a]);
    gsf_append_chunk(ctx, chunks, "TRNR", state, sizeof state);
    gsf__column columns[GSF__COLUMNS];
    gsf__model_columns(model, columns);
    for (int k = 0; k < GSF__SAVED_COLUMNS; k++)
        gsf_append_chunk(ctx, chunks, gsf__column_tags[k], columns[k].data, model->count * columns[k].row);
    gsf_append_chunk(ctx, chunks, "TRST", model->rest, gsf__model_blocks(model->count));
}

// Validates an array of an untrusted file: size, finite values, second moments and gradient sums >= 0, ids < next_id.
static gsf_result gsf__trainer_check_array(gsf_context* ctx, const char* name, int i, const gsf_chunk* chunk,
                                           size_t count, size_t row, uint32_t next_id) {
    if (chunk->size != count * row)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: chunk %s has %zu bytes, expected %zu", name, chunk->tag, chunk->size,
                        count * row);
    const char* p = (const char*)chunk->data;
    for (size_t k = 0; k < chunk->size / 4; k++) {
        uint32_t bits;
        float value;
        memcpy(&bits, p + 4 * k, 4);
        memcpy(&value, p + 4 * k, 4);
        int ok = 1;
        if (i < GSF__ID_COLUMN || i == GSF__ID_COLUMN + 1)
            ok = fabsf(value) <= FLT_MAX && (i < 2 * GSF__GROUPS || value >= 0.0f);
        else if (i == GSF__ID_COLUMN) ok = bits < next_id;
        if (!ok) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: chunk %s: bad value at %zu", name, chunk->tag, 4 * k);
    }
    return GSF_OK;
}

GSF_API gsf_result gsf_splat_parse_trainer(gsf_context* ctx, gsf_trainer* trainer, const char* name,
                                           const void* chunks, size_t size) {
    gsf__model* model = &trainer->model;
    gsf_chunk chunk;
    GSF__TRY(gsf_check_chunks(ctx, name, chunks, size));
    if (!gsf_find_chunk(chunks, size, "TRNR", &chunk) || chunk.size != GSF__STATE_SIZE)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no trainer state (chunk TRNR of %d bytes)", name, GSF__STATE_SIZE);
    const char* state = (const char*)chunk.data;
    uint32_t mark;
    memcpy(&mark, state, 4);
    if (mark != GSF__BYTE_ORDER_MARK)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: written on a machine with a different byte order", name);
    const uint64_t iteration = gsf__load_le(state + 4, 4), sh_degree = gsf__load_le(state + 8, 4);
    const uint32_t next_id = (uint32_t)gsf__load_le(state + 12, 4), weight = (uint32_t)gsf__load_le(state + 20, 4);
    const uint64_t first_bands = gsf__load_le(state + 16, 4), count = gsf__load_le(state + 24, 8);
    const uint64_t restored_steps = gsf__load_le(state + 32, 8);
    float restored_weight;
    memcpy(&restored_weight, &weight, 4);
    if (iteration > (uint64_t)trainer->desc.iterations || sh_degree != (uint64_t)model->sh_degree || first_bands < 1 ||
        first_bands > 4 || count > size || restored_steps > iteration || !(fabsf(restored_weight) <= FLT_MAX))
        return gsf_fail(ctx, GSF_ERROR_FORMAT,
                        "%s: does not fit: iteration %llu of %d, %llu restored, SH degree %llu (here %d), %llu splats", name,
                        (unsigned long long)iteration, (int)trainer->desc.iterations, (unsigned long long)restored_steps,
                        (unsigned long long)sh_degree, (int)model->sh_degree, (unsigned long long)count);
    double origin[3];
    for (int a = 0; a < 3; a++) {
        origin[a] = gsf__load_f64(state + 56 + 8 * a);
        if (!isfinite(origin[a])) return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: origin is not finite", name);
    }
    gsf__column columns[GSF__COLUMNS];
    gsf__model_columns(model, columns);
    for (int k = 0; k < GSF__SAVED_COLUMNS; k++) {
        if (!gsf_find_chunk(chunks, size, gsf__column_tags[k], &chunk))
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: chunk %s is missing", name, gsf__column_tags[k]);
        GSF__TRY(gsf__trainer_check_array(ctx, name, k, &chunk, (size_t)count, columns[k].row, next_id));
    }
    const size_t blocks = gsf__model_blocks((size_t)count);
    if (!gsf_find_chunk(chunks, size, "TRST", &chunk) || chunk.size != blocks)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no chunk TRST of %zu bytes", name, blocks);
    for (size_t b = 0; b < blocks; b++) {
        const unsigned behind = ((const unsigned char*)chunk.data)[b];
        if (behind >= GSF__REST_MOST || behind > iteration)
            return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: chunk TRST: bad value at %zu", name, b);
    }
    GSF__TRY(gsf__model_reserve(ctx, model, (size_t)count));

    gsf__trainer_hide(trainer);
    memset(model->rest, 0, gsf__model_blocks(model->capacity));
    if (blocks) memcpy(model->rest, chunk.data, blocks);
    gsf__model_columns(model, columns); // anew, because the arrays may have been moved
    for (int k = 0; k < GSF__SAVED_COLUMNS; k++)
        if (gsf_find_chunk(chunks, size, gsf__column_tags[k], &chunk) && chunk.size)
            memcpy(columns[k].data, chunk.data, chunk.size);
    model->count = (size_t)count;
    model->next_id = next_id;
    memcpy(trainer->view.origin, origin, sizeof origin);
    trainer->iteration = (int32_t)iteration;
    trainer->first_bands = (int32_t)first_bands;
    trainer->restored_weight = restored_weight;
    trainer->restored_steps = restored_steps;
    trainer->rejected = (size_t)gsf__load_le(state + 40, 8);
    gsf__trainer_refresh_view(trainer);
    gsf__trainer_prepare_lazy(ctx, trainer);
    if (!model->lazy) gsf__parallel_for(ctx, gsf__model_chunks(model->count), gsf__lazy_all_chunk, &trainer->lazy);
    if (gsf__load_le(state + 48, 8) != gsf__trainer_settings(trainer))
        gsf_log(ctx, GSF_LOG_WARNING, "%s: the settings or views differ from those of the checkpoint", name);
    return GSF_OK;
}

GSF_API gsf_result gsf_splat_make_trainer(gsf_context* ctx, const gsf_train_desc* desc, const gsf_train_view* views,
                                          size_t view_count, const gsf_splats* initial, gsf_trainer** out) {
    *out = NULL;
    if (desc) GSF__TRY(gsf__check_train_canaries(ctx, desc));
    gsf_trainer* trainer = (gsf_trainer*)gsf_alloc_zeroed(ctx, 1, sizeof *trainer);
    if (!trainer) return GSF_ERROR_OUT_OF_MEMORY;
    trainer->desc = gsf__train_desc_defaults(desc);
    trainer->restored_weight = 1.0f;
    const gsf_result result = gsf__trainer_setup(ctx, trainer, views, view_count, initial);
    if (result != GSF_OK) gsf_splat_destroy_trainer(ctx, trainer);
    else *out = trainer;
    return result;
}

GSF_API void gsf_splat_destroy_trainer(gsf_context* ctx, gsf_trainer* trainer) {
    if (!trainer) return;
    gsf__photo_set_destroy(ctx, &trainer->photos);
    gsf__photo_set_destroy(ctx, &trainer->restored);
    gsf__photo_set_destroy(ctx, &trainer->coarse);
    gsf__model_destroy(ctx, &trainer->model);
    gsf__loss_destroy_scratch(ctx, &trainer->loss);
    if (trainer->rasterizer) gsf_splat_destroy_rasterizer(ctx, trainer->rasterizer);
    gsf_free(ctx, trainer->color);
    gsf_free(ctx, trainer->d_color);
    gsf_free(ctx, trainer->depth);
    gsf_free(ctx, trainer->d_depth);
    gsf_free(ctx, trainer->means);
    gsf_free(ctx, trainer);
}

GSF_API gsf_train_desc gsf_splat_get_trainer_desc(const gsf_trainer* trainer) { return trainer->desc; }

// Restored views are replaced in two steps: gsf__restored_make does all that can fail, gsf__restored_take swaps them.
static gsf_result gsf__restored_make(gsf_context* ctx, gsf_trainer* trainer, const gsf_train_view* views, size_t count,
                                     gsf__photo_set* out) {
    GSF__TRY(gsf__photo_set_make(ctx, views, count, "restored view", out));
    const gsf_result result = gsf__trainer_reserve_images(ctx, trainer, out);
    if (result != GSF_OK) gsf__photo_set_destroy(ctx, out);
    return result;
}

static void gsf__restored_take(gsf_context* ctx, gsf_trainer* trainer, const gsf__photo_set* set) {
    gsf__photo_set_destroy(ctx, &trainer->restored);
    trainer->restored = *set;
}

GSF_API gsf_result gsf_splat_set_restored_views(gsf_context* ctx, gsf_trainer* trainer, const gsf_train_view* views,
                                                size_t count) {
    gsf__photo_set set;
    GSF__TRY(gsf__restored_make(ctx, trainer, views, count, &set));
    gsf__restored_take(ctx, trainer, &set);
    return GSF_OK;
}

GSF_API void gsf_splat_set_restored_weight(gsf_trainer* trainer, float lambda) {
    trainer->restored_weight = lambda > 0.0f && lambda <= 1e6f ? lambda : 0.0f;
}

GSF_API gsf_result gsf_splat_render_trainer(gsf_context* ctx, gsf_trainer* trainer, const gsf_camera* camera,
                                            const gsf_render_output* out) {
    gsf_render_desc render = trainer->desc.render;
    render.sh_bands = gsf__trainer_bands(trainer, trainer->iteration);
    return gsf_splat_render(ctx, trainer->rasterizer, gsf__trainer_show(ctx, trainer), camera, &render, out);
}

GSF_API gsf_result gsf_splat_copy_trained(gsf_context* ctx, const gsf_trainer* trainer, gsf_splats* out) {
    const gsf_splats* view = gsf__trainer_show(ctx, (gsf_trainer*)trainer);
    GSF__TRY(gsf_splat_make(ctx, view->count, view->sh_degree, out));
    gsf__column from[GSF__SPLAT_COLUMNS], to[GSF__SPLAT_COLUMNS];
    memcpy(out->origin, view->origin, sizeof out->origin);
    memcpy(out->background, view->background, sizeof out->background);
    gsf__splat_columns(view, from);
    gsf__splat_columns(out, to);
    for (int k = 0; k < GSF__SPLAT_COLUMNS && view->count; k++) memcpy(to[k].data, from[k].data, view->count * to[k].row);
    return GSF_OK;
}

GSF_API const gsf_splats* gsf_splat_get_trained(const gsf_trainer* trainer) {
    return gsf__trainer_show(NULL, (gsf_trainer*)trainer);
}

// ---- >>carry -------------------------------------------------------------------

/* Carries photos into other views: what a reference shows in a frame is found through the reference's own depth map, so
   that floaters in front of the frame's camera do not matter.
       study     once per run: depth maps of the photos by stereo between them, and the exposure of each photo relative to
                 their mean. Depends only on photos, cameras and the points that guide the search, so that a resumed run
                 finds the same again.
       open      once per round, with the splats' renders: the depth of a reference is that of stereo or, where stereo is
                 silent, that of the splats. Every pixel gets a score from the other references: do they show a surface at
                 that depth, do their photos look alike around it, does one look through it (free-space violation)?
       draw      per frame and reference: the depth map, cut at depth edges, is rasterized as a triangle mesh into a z-buffer
                 of the frame. A pixel's depth there gives its position in the reference, and so all else.
   A brightness step between photos would become an edge in the frame where one photo ends, so colours are brought to
   one exposure per frame: that of the photos around it, since exposure and shading change gradually along a capture,
   and since the frame would otherwise contradict the photos near it. Residuals (photo - render) are not: the splats
   follow each photo's own exposure.
   A camera with automatic exposure takes darker pictures of brighter views. What the photos tell of it (meter, once per
   run), final frames follow (gsf__carry_meter_frame): a new photo from there would. */

typedef struct gsf__carry_reference {
    gsf_camera camera;
    double center[3];
    double focus[3]; // world point at the image centre, at the mean inverse depth
    // The smallest types that represent the values exactly, since the references of all views are kept during a round.
    uint8_t* bytes;  // (H,W,3): 255 times the colour, or NULL
    float* color;    // (H,W,3), only if `bytes` could not represent it exactly
    float* residual; // (H,W,3): colour - render; NULL without renders
    float* depth;    // (H,W), 0 = no surface
    uint8_t* score;  // (H,W), percent
    uint8_t* links;  // (H,W): GSF__CARRY_UPPER, GSF__CARRY_LOWER: triangles of the surface below and right of a pixel
} gsf__carry_reference;

typedef struct gsf__carry_study { // of one photo
    int32_t width, height;      // of the depth map
    float* depth;               // (height,width) where stereo confirms it, else 0; NULL = none
    float gain[3], offset[3];   // colour of the mean exposure = gain * colour + offset
    double brightness;          // logarithm of the mean colour, at the mean exposure
} gsf__carry_study;

typedef struct gsf__carrier {
    int32_t study_count;
    gsf__carry_study* studies;        // of the run; NULL before gsf__carrier_study
    double automatic;                 // share of a view's brightness that the camera's exposure makes up for: 0 = fixed
    int32_t count;
    gsf__carry_reference* references; // of the round; NULL unless open
    int has_residuals;
    float gain[3], offset[3];         // what brings the exposure of the frame that was drawn last to the mean
    double brightness;                // of the photos around that frame
    float* inv_z;                     // scratch for one frame: z-buffers, one per slot
    void* vertices;                   // of one reference, and for each of its rows the range of their positions
    size_t inv_z_capacity, vertex_capacity;
} gsf__carrier;

#define GSF__CARRY_DEPTH_TOLERANCE 0.04f // relative depth difference up to which points lie on the same surface
#define GSF__CARRY_EDGE 1.06f            // depth ratio across one pixel above which a surface ends
enum {
    GSF__CARRY_VERIFIED = 50,  // score from which depth and colour are confirmed by another photo
    GSF__CARRY_ALIKE = 50,     // percent: likeness from which windows of two photos show the same
    GSF__CARRY_WINDOW = 3,     // radius of the windows that are compared between photos
    GSF__CARRY_BAND = 16,      // rows of a frame that are drawn together
    GSF__CARRY_UPPER = 1,      // pixels (0,0), (1,0), (0,1) from here lie on one surface
    GSF__CARRY_LOWER = 2,      // pixels (1,0), (1,1), (0,1)
    GSF__CARRY_OTHERS = 8,     // most references that judge another one
    GSF__CARRY_LEVELS = 6,     // of the pyramid that corrects the splats' depth
    GSF__CARRY_SLOTS = 9,      // most references that are ranked
    GSF__CARRY_STEREO_SIZE = 320, // most pixels along a side that stereo works with
};

static void gsf__carrier_close(gsf_context* ctx, gsf__carrier* carrier) {
    for (int32_t i = 0; i < carrier->count; i++) {
        gsf__carry_reference* ref = carrier->references + i;
        gsf_free(ctx, ref->bytes);
        gsf_free(ctx, ref->color);
        gsf_free(ctx, ref->residual);
        gsf_free(ctx, ref->depth);
        gsf_free(ctx, ref->score);
        gsf_free(ctx, ref->links);
    }
    gsf_free(ctx, carrier->references);
    gsf_free(ctx, carrier->inv_z);
    gsf_free(ctx, carrier->vertices);
    carrier->references = NULL;
    carrier->inv_z = NULL;
    carrier->vertices = NULL;
    carrier->inv_z_capacity = carrier->vertex_capacity = 0;
    carrier->count = 0;
}

static void gsf__carrier_forget(gsf_context* ctx, gsf__carrier* carrier) { // closes it, too
    gsf__carrier_close(ctx, carrier);
    for (int32_t i = 0; i < carrier->study_count; i++) gsf_free(ctx, carrier->studies[i].depth);
    gsf_free(ctx, carrier->studies);
    memset(carrier, 0, sizeof *carrier);
}

// World point at image position (x,y) and camera depth z.
static void gsf__unproject(const gsf_camera* camera, double x, double y, double z, double out[3]) {
    const double* m = camera->w2c;
    const double p[3] = {(x - camera->cx) / camera->fx * z - m[12], (y - camera->cy) / camera->fy * z - m[13], z - m[14]};
    for (int c = 0; c < 3; c++) out[c] = m[4 * c] * p[0] + m[4 * c + 1] * p[1] + m[4 * c + 2] * p[2];
}

// Bilinear interpolation at a continuous position: the four pixels around it (pixel centres at .5) and its offset.
typedef struct gsf__taps {
    size_t at[4]; // top left and right, bottom left and right
    float x, y;
} gsf__taps;

static int gsf__find_taps(const gsf_camera* image, double x, double y, gsf__taps* out) { // returns 0 outside the image
    const int32_t width = image->width, height = image->height;
    const double fx = x - 0.5, fy = y - 0.5;
    if (!(fx > -0.5 && fy > -0.5 && fx < width - 0.5 && fy < height - 0.5)) return 0;
    const int32_t x0 = fx < 0.0 ? 0 : (int32_t)fx, y0 = fy < 0.0 ? 0 : (int32_t)fy;
    const int32_t x1 = x0 + 1 < width ? x0 + 1 : x0, y1 = y0 + 1 < height ? y0 + 1 : y0;
    const size_t top = (size_t)y0 * (size_t)width, bottom = (size_t)y1 * (size_t)width;
    out->x = fx < 0.0 ? 0.0f : (float)(fx - x0);
    out->y = fy < 0.0 ? 0.0f : (float)(fy - y0);
    out->at[0] = top + (size_t)x0;
    out->at[1] = top + (size_t)x1;
    out->at[2] = bottom + (size_t)x0;
    out->at[3] = bottom + (size_t)x1;
    return 1;
}

static float gsf__blend_taps(const gsf__taps* taps, const float v[4]) {
    const float top = v[0] * (1.0f - taps->x) + v[1] * taps->x, bottom = v[2] * (1.0f - taps->x) + v[3] * taps->x;
    return top * (1.0f - taps->y) + bottom * taps->y;
}

static float gsf__sample_floats(const float* plane, size_t channels, size_t channel, const gsf__taps* taps) {
    float v[4];
    for (int k = 0; k < 4; k++) v[k] = plane[taps->at[k] * channels + channel];
    return gsf__blend_taps(taps, v);
}

static float gsf__sample_bytes(const uint8_t* plane, size_t channels, size_t channel, double one, const gsf__taps* taps) {
    float v[4];
    for (int k = 0; k < 4; k++) v[k] = (float)(plane[taps->at[k] * channels + channel] / one);
    return gsf__blend_taps(taps, v);
}

// Depth of the pixel that contains a continuous position; 0 outside the image.
static float gsf__nearest_depth(const gsf__carry_reference* ref, double u, double v) {
    if (!(u >= 0.0 && v >= 0.0 && u < ref->camera.width && v < ref->camera.height)) return 0.0f;
    return ref->depth[(size_t)v * (size_t)ref->camera.width + (size_t)u];
}

static float gsf__photo_color(const gsf__carry_reference* ref, size_t channel, const gsf__taps* taps) {
    return ref->bytes ? gsf__sample_bytes(ref->bytes, 3, channel, 255.0, taps)
                      : gsf__sample_floats(ref->color, 3, channel, taps);
}

static float gsf__carry_expose_value(const gsf__carrier* carrier, int32_t reference, size_t channel, float value) {
    if (reference >= carrier->study_count) return value;
    value = carrier->studies[reference].gain[channel] * value + carrier->studies[reference].offset[channel];
    value = (value - carrier->offset[channel]) / carrier->gain[channel];
    return value > 1.0f ? 1.0f : value > 0.0f ? value : 0.0f;
}

// A channel of the photo at the exposure of the frame.
static float gsf__carry_color(const gsf__carrier* carrier, int32_t reference, size_t channel, const gsf__taps* taps) {
    return gsf__carry_expose_value(carrier, reference, channel,
                                   gsf__photo_color(carrier->references + reference, channel, taps));
}

static void gsf__carry_pixel(const gsf__carrier* carrier, int32_t reference, size_t at, float rgb[3]) { // the same, of a pixel
    const gsf__carry_reference* ref = carrier->references + reference;
    for (size_t c = 0; c < 3; c++)
        rgb[c] = gsf__carry_expose_value(carrier, reference, c,
                                         ref->bytes ? (float)(ref->bytes[3 * at + c] / 255.0) : ref->color[3 * at + c]);
}

// Finds the (at most `most`) references whose viewing direction to their focus is closest to that of a camera at `center`.
// Ties go to the lower index. Returns their number.
static int gsf__carry_nearest(const gsf__carrier* carrier, const double center[3], int32_t* nearest, int most) {
    double best[GSF__CARRY_SLOTS];
    int count = 0;
    for (int32_t k = 0; k < carrier->count; k++) {
        const double cosine = gsf__ray_cosine(carrier->references[k].focus, center, carrier->references[k].center);
        int at = count < most ? count++ : most;
        for (; at > 0 && best[at - 1] < cosine; at--)
            if (at < most) {
                best[at] = best[at - 1];
                nearest[at] = nearest[at - 1];
            }
        if (at < most) {
            best[at] = cosine;
            nearest[at] = k;
        }
    }
    return count;
}

// Sets the exposure of a frame at `center` (NULL: the mean): that of the references, weighted by the inverse of the squared
// angle between their viewing directions and the frame's.
static void gsf__carry_set_exposure(gsf__carrier* carrier, const double* center) {
    double gain[3] = {0.0, 0.0, 0.0}, offset[3] = {0.0, 0.0, 0.0}, brightness = 0.0, total = 0.0;
    int32_t nearest[GSF__CARRY_SLOTS];
    const int count = center && carrier->study_count ? gsf__carry_nearest(carrier, center, nearest, GSF__CARRY_SLOTS) : 0;
    for (int k = 0; k < count; k++) {
        const gsf__carry_reference* ref = carrier->references + nearest[k];
        const gsf__carry_study* study = carrier->studies + nearest[k];
        const double weight = 1.0 / (fmax(0.0, 1.0 - gsf__ray_cosine(ref->focus, center, ref->center)) + 1e-4);
        total += weight;
        brightness += weight * study->brightness;
        for (int c = 0; c < 3; c++) {
            gain[c] += weight * (double)study->gain[c];
            offset[c] += weight * (double)study->offset[c];
        }
    }
    for (int c = 0; c < 3; c++) {
        carrier->gain[c] = count ? (float)(gain[c] / total) : 1.0f;
        carrier->offset[c] = count ? (float)(offset[c] / total) : 0.0f;
    }
    carrier->brightness = count ? brightness / total : 0.0;
}

// ---- what depends only on the photos

// A value of a photo of any layout with dtype u8 or f32, as 0..1.
static float gsf__carry_photo_value(const gsf_image* photo, int64_t x, int64_t y, int c) {
    if (photo->dtype != GSF_U8) return gsf__get_pixel(photo, x, y, c);
    return (float)((const uint8_t*)photo->data)[y * photo->stride_y + x * photo->stride_x + c * photo->stride_c] / 255.0f;
}

// A pixel of it, interpolated.
static void gsf__carry_photo_color(const gsf_image* photo, const gsf__taps* taps, float rgb[3]) {
    for (int c = 0; c < 3; c++) {
        float v[4];
        for (int k = 0; k < 4; k++)
            v[k] = gsf__carry_photo_value(photo, (int64_t)taps->at[k] % photo->width, (int64_t)taps->at[k] / photo->width, c);
        rgb[c] = gsf__blend_taps(taps, v);
    }
}

typedef struct gsf__carry_pair { // the same point in two photos
    int32_t photo[2];
    float rgb[2][3];
    float share;  // weight: pairs of one two photos count as much as GSF__CARRY_EVIDENCE of them
} gsf__carry_pair;

typedef struct gsf__carry_pairs {
    gsf__carry_pair* pairs;
    size_t count, capacity;
} gsf__carry_pairs;

enum { GSF__CARRY_EVIDENCE = 10, GSF__CARRY_SWEEPS = 60 };

// Adds points that the stereo depth maps of photos i and k agree on.
static gsf_result gsf__carry_match(gsf_context* ctx, const gsf__carrier* carrier, const gsf_scene_view* views, int32_t i,
                                   int32_t k, gsf__carry_pairs* out) {
    const gsf__carry_study *a = carrier->studies + i, *b = carrier->studies + k;
    const gsf_camera from = gsf_resize_camera(&views[i].camera, a->width, a->height);
    const gsf_camera to = gsf_resize_camera(&views[k].camera, b->width, b->height);
    const size_t before = out->count;
    for (int32_t y = 1; y < a->height; y += 3)
        for (int32_t x = 1; x < a->width; x += 3) {
            const float depth = a->depth[(size_t)y * (size_t)a->width + (size_t)x];
            double point[3], u, v, z;
            if (!(depth > 0.0f)) continue;
            gsf__unproject(&from, x + 0.5, y + 0.5, (double)depth, point);
            if (!gsf_project_point(&to, point, &u, &v, &z) || !(u >= 0.0 && v >= 0.0 && u < b->width && v < b->height))
                continue;
            const float there = b->depth[(size_t)v * (size_t)b->width + (size_t)u];
            if (!(there > 0.0f && fabs(z - (double)there) <= 0.02 * z)) continue;
            gsf__carry_pair pair;
            gsf__taps taps;
            int usable = 1;
            for (int side = 0; side < 2; side++) {
                const gsf_scene_view* view = views + (side ? k : i);
                const gsf__carry_study* study = side ? b : a;
                const double sx = (double)view->camera.width / study->width, sy = (double)view->camera.height / study->height;
                pair.photo[side] = side ? k : i;
                usable &= gsf__find_taps(&view->camera, (side ? u : x + 0.5) * sx, (side ? v : y + 0.5) * sy, &taps);
                if (!usable) break;
                gsf__carry_photo_color(&view->image, &taps, pair.rgb[side]);
                for (int c = 0; c < 3; c++) usable &= pair.rgb[side][c] > 0.02f && pair.rgb[side][c] < 0.98f; // not clipped
            }
            if (!usable) continue;
            GSF__TRY(gsf__reserve(ctx, (void**)&out->pairs, &out->capacity, out->count, out->count + 1, sizeof *out->pairs));
            out->pairs[out->count++] = pair;
        }
    const float n = (float)(out->count - before);
    for (size_t p = before; p < out->count; p++)
        out->pairs[p].share = n > (float)GSF__CARRY_EVIDENCE ? (float)GSF__CARRY_EVIDENCE / n : 1.0f;
    return GSF_OK;
}

// One sweep of the fit of a channel: every photo's gain and offset against those of its partners as they are. The loss is
// that of Geman and McClure with a scale of 0.06, since highlights and wrong matches differ by more. Priors: gains within
// 0.15 of 1, offsets within 0.015 of 0, for residuals of 0.03. sums: (photos,5), scratch.
static void gsf__carry_fit(gsf__carrier* carrier, const gsf__carry_pairs* pairs, int channel, double* sums) {
    memset(sums, 0, (size_t)carrier->study_count * 5 * sizeof *sums);
    for (size_t p = 0; p < pairs->count; p++) {
        const gsf__carry_pair* pair = pairs->pairs + p;
        double corrected[2];
        for (int side = 0; side < 2; side++) {
            const gsf__carry_study* study = carrier->studies + pair->photo[side];
            corrected[side] = (double)(study->gain[channel] * pair->rgb[side][channel] + study->offset[channel]);
        }
        const double off = (corrected[0] - corrected[1]) / 0.06, robust = 1.0 / (1.0 + off * off);
        const double weight = (double)pair->share * robust * robust;
        for (int side = 0; side < 2; side++) {
            double* sum = sums + 5 * (size_t)pair->photo[side];
            const double a = (double)pair->rgb[side][channel], target = corrected[1 - side];
            sum[0] += weight * a * a;
            sum[1] += weight * a;
            sum[2] += weight;
            sum[3] += weight * a * target;
            sum[4] += weight * target;
        }
    }
    double log_gain = 0.0, offset = 0.0;
    for (int32_t i = 0; i < carrier->study_count; i++) {
        gsf__carry_study* study = carrier->studies + i;
        const double* sum = sums + 5 * (size_t)i;
        const double gain_prior = 0.03 * 0.03 / (0.15 * 0.15), offset_prior = 0.03 * 0.03 / (0.015 * 0.015);
        const double aa = sum[0] + gain_prior, bb = sum[2] + offset_prior, ab = sum[1], det = aa * bb - ab * ab;
        const double at = sum[3] + gain_prior, bt = sum[4];
        const double gain = (at * bb - bt * ab) / det, shift = (aa * bt - ab * at) / det;
        study->gain[channel] += 0.5f * ((float)(gain < 0.25 ? 0.25 : gain > 4.0 ? 4.0 : gain) - study->gain[channel]);
        study->offset[channel] += 0.5f * ((float)shift - study->offset[channel]);
        log_gain += gsf__log_f64((double)study->gain[channel]) / carrier->study_count;
        offset += (double)study->offset[channel] / carrier->study_count;
    }
    const float scale = (float)gsf__exp_f64(-log_gain);
    for (int32_t i = 0; i < carrier->study_count; i++) {
        carrier->studies[i].gain[channel] *= scale;
        carrier->studies[i].offset[channel] = (carrier->studies[i].offset[channel] - (float)offset) * scale;
    }
}

#define GSF__CARRY_STEP 0.01f // deviation of gain and offset up to which a photo counts as of the mean exposure

// Exposure of the photos relative to their mean. Photos without evidence, and all if no two overlap, keep the identity.
static gsf_result gsf__carry_expose(gsf_context* ctx, gsf__carrier* carrier, const gsf_scene_view* views) {
    gsf__carry_pairs pairs;
    memset(&pairs, 0, sizeof pairs);
    gsf_result result = GSF_OK;
    double* sums = (double*)gsf_alloc(ctx, (size_t)carrier->study_count, 5 * sizeof *sums);
    if (!sums) return GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < carrier->study_count; i++)
        for (int32_t k = i + 1; k < carrier->study_count && k <= i + GSF__CARRY_OTHERS && result == GSF_OK; k++)
            if (carrier->studies[i].depth && carrier->studies[k].depth)
                result = gsf__carry_match(ctx, carrier, views, i, k, &pairs);
    for (int sweep = 0; sweep < GSF__CARRY_SWEEPS && pairs.count && result == GSF_OK; sweep++)
        for (int c = 0; c < 3; c++) gsf__carry_fit(carrier, &pairs, c, sums);
    for (int32_t i = 0; i < carrier->study_count; i++) {
        gsf__carry_study* study = carrier->studies + i;
        int step = 0;
        for (int c = 0; c < 3; c++)
            step |= fabsf(study->gain[c] - 1.0f) > GSF__CARRY_STEP || fabsf(study->offset[c]) > GSF__CARRY_STEP;
        for (int c = 0; c < 3 && !step; c++) {
            study->gain[c] = 1.0f;
            study->offset[c] = 0.0f;
        }
    }
    gsf_free(ctx, pairs.pairs);
    gsf_free(ctx, sums);
    return result;
}

// A photo's mean colour over the pixels that its mask leaves.
static void gsf__carry_mean(const gsf_scene_view* view, double mean[3]) {
    const gsf_image *photo = &view->image, *mask = &view->weight;
    double pixels = 0.0;
    mean[0] = mean[1] = mean[2] = 0.0;
    for (int64_t y = 0; y < photo->height; y++)
        for (int64_t x = 0; x < photo->width; x++) {
            const float weight = mask->data ? gsf__carry_photo_value(mask, x, y, 0) : 1.0f;
            pixels += (double)weight;
            for (int c = 0; c < 3; c++) mean[c] += (double)(weight * gsf__carry_photo_value(photo, x, y, c));
        }
    for (int c = 0; c < 3; c++) mean[c] /= fmax(pixels, 1.0);
}

// Finds the photos' brightness, and how the camera's exposure followed it: the slope of a line through the photos. Those of a
// fixed exposure give 0, those of an automatic one 0.7 to 1; where all are nearly as bright, no slope can be told: prior 0.
static void gsf__carry_meter(gsf__carrier* carrier, const gsf_scene_view* views) {
    const double count = carrier->study_count, unsure = count * 0.02 * 0.02, dark = 1e-3;
    double brightness = 0.0, exposure = 0.0, square = 0.0, product = 0.0;
    for (int32_t i = 0; i < carrier->study_count; i++) {
        gsf__carry_study* study = carrier->studies + i;
        double mean[3], as_taken = 0.0, at_one_exposure = 0.0;
        gsf__carry_mean(views + i, mean);
        for (int c = 0; c < 3; c++) {
            as_taken += mean[c] / 3.0;
            at_one_exposure += ((double)study->gain[c] * mean[c] + (double)study->offset[c]) / 3.0;
        }
        study->brightness = gsf__log_f64(fmax(at_one_exposure, dark));
        const double exposed = gsf__log_f64(fmax(as_taken, dark)) - study->brightness;
        brightness += study->brightness;
        exposure += exposed;
        square += study->brightness * study->brightness;
        product += study->brightness * exposed;
    }
    square -= brightness * brightness / count;
    product -= brightness * exposure / count;
    const double slope = -product / (square + unsure);
    carrier->automatic = slope < 1.0 ? fmax(slope, 0.0) : 1.0;
}

// The factor by which the camera would have exposed a frame otherwise than the photos around it, whose exposure its render has:
// below 1 if it is brighter than these photos, at most half a stop. What no splat covers is taken to be as bright as they.
static float gsf__carry_meter_frame(gsf__carrier* carrier, const gsf_camera* camera, const gsf_image* render,
                                    const gsf_image* alpha, const float background[3], double share) {
    const double most = 0.34657359027997264; // log 2 / 2
    double center[3], sum = 0.0;
    gsf_get_camera_center(camera, center);
    gsf__carry_set_exposure(carrier, center);
    const float around = (float)gsf__exp_f64(carrier->brightness);
    for (int64_t y = 0; y < render->height; y++)
        for (int64_t x = 0; x < render->width; x++)
            for (int c = 0; c < 3; c++) {
                const float hole = 1.0f - gsf__get_pixel(alpha, x, y, 0);
                const float splats = gsf__get_pixel(render, x, y, c) - hole * background[c];
                sum += (double)(carrier->gain[c] * splats + (1.0f - hole) * carrier->offset[c] + hole * around);
            }
    const double frame = gsf__log_f64(fmax(sum / (3.0 * (double)render->width * (double)render->height), 1e-3));
    const double change = share * carrier->automatic * (carrier->brightness - frame);
    return (float)gsf__exp_f64(change < -most ? -most : change < most ? change : most);
}

static gsf_result gsf__carry_keep_maps(gsf_context* ctx, gsf__carrier* carrier, const gsf_dense* dense) {
    for (size_t m = 0; m < dense->map_count; m++) {
        const gsf_dense_map* map = dense->maps + m;
        gsf__carry_study* study = carrier->studies + map->view;
        const size_t pixels = (size_t)map->camera.width * (size_t)map->camera.height;
        study->depth = (float*)gsf_alloc(ctx, pixels, sizeof(float));
        if (!study->depth) return GSF_ERROR_OUT_OF_MEMORY;
        memcpy(study->depth, map->depth, pixels * sizeof(float));
        study->width = map->camera.width;
        study->height = map->camera.height;
    }
    return GSF_OK;
}

// views: photos (u8 or f32, 3 channels) and cameras; weight as in a scene. points: (point_count,3) world, which guide the
// search for depths; may be none. After an error the carrier has no studies.
static gsf_result gsf__carrier_study(gsf_context* ctx, gsf__carrier* carrier, gsf_scene_view* views, int32_t count,
                                     double* points, size_t point_count, uint64_t seed) {
    gsf_dense_desc desc;
    gsf_dense dense;
    gsf_scene scene;
    memset(&desc, 0, sizeof desc);
    memset(&dense, 0, sizeof dense);
    memset(&scene, 0, sizeof scene);
    carrier->studies = (gsf__carry_study*)gsf_alloc_zeroed(ctx, (size_t)count, sizeof *carrier->studies);
    uint32_t* order = (uint32_t*)gsf_alloc(ctx, (size_t)count, sizeof *order);
    scene.track_begin = (size_t*)gsf_alloc_zeroed(ctx, point_count + 1, sizeof *scene.track_begin);
    gsf_result result = carrier->studies && order && scene.track_begin ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    if (carrier->studies) carrier->study_count = count;
    for (int32_t i = 0; i < count && result == GSF_OK; i++) {
        order[i] = (uint32_t)i;
        for (int c = 0; c < 3; c++) carrier->studies[i].gain[c] = 1.0f;
    }
    scene.view_count = (size_t)count;
    scene.views = views;
    scene.points = points;
    scene.point_count = point_count;
    desc.seed = seed;
    desc.want_maps = 1;
    desc.spacing = 1024; // the points are not needed
    desc.max_size = GSF__CARRY_STEREO_SIZE;
    desc.max_cost = 0.5f;      // more than for points that splats are made of: the score also compares the photos
    desc.max_cost_many = 0.6f;
    int large = count > 1;
    for (int32_t i = 0; i < count; i++)
        large &= views[i].camera.width >= GSF__DENSE_MIN_SIDE && views[i].camera.height >= GSF__DENSE_MIN_SIDE;
    if (result == GSF_OK && large) // its windows would fill a smaller photo
        result = gsf_splat_make_dense(ctx, &scene, order, (size_t)count, NULL, &desc, &dense, NULL);
    if (result == GSF_OK) result = gsf__carry_keep_maps(ctx, carrier, &dense);
    if (result == GSF_OK) result = gsf__carry_expose(ctx, carrier, views);
    if (result == GSF_OK) gsf__carry_meter(carrier, views);
    gsf_splat_destroy_dense(ctx, &dense);
    gsf_free(ctx, scene.track_begin);
    gsf_free(ctx, order);
    if (result != GSF_OK) gsf__carrier_forget(ctx, carrier);
    return result;
}

// ---- references of a round

static void gsf__carry_find_focus(gsf__carry_reference* ref) { // middle pixel at the mean inverse depth
    const size_t pixels = (size_t)ref->camera.width * (size_t)ref->camera.height;
    double sum = 0.0, count = 0.0;
    for (size_t p = 0; p < pixels; p++)
        if (ref->depth[p] > 0.0f) {
            sum += 1.0 / (double)ref->depth[p];
            count += 1.0;
        }
    gsf__unproject(&ref->camera, 0.5 * ref->camera.width, 0.5 * ref->camera.height, sum > 0.0 ? count / sum : 1.0,
                   ref->focus);
}

// Copies a reference. What it allocates is freed by gsf__carrier_close, also after an error.
static gsf_result gsf__carry_take(gsf_context* ctx, const gsf_reference* from, int has_residuals, gsf__carry_reference* ref) {
    const gsf_camera* camera = &from->camera;
    GSF__TRY(gsf_check_camera(ctx, camera));
    const int32_t width = camera->width, height = camera->height;
    const size_t pixels = (size_t)width * (size_t)height;
    ref->camera = *camera;
    gsf_get_camera_center(camera, ref->center);
    ref->bytes = (uint8_t*)gsf_alloc(ctx, pixels, 3);
    ref->color = (float*)gsf_alloc(ctx, pixels, 3 * sizeof(float));
    ref->residual = has_residuals ? (float*)gsf_alloc(ctx, pixels, 3 * sizeof(float)) : NULL;
    ref->depth = (float*)gsf_alloc(ctx, pixels, sizeof(float));
    ref->score = (uint8_t*)gsf_alloc_zeroed(ctx, pixels, 1);
    ref->links = (uint8_t*)gsf_alloc_zeroed(ctx, pixels, 1);
    if (!ref->bytes || !ref->color || (has_residuals && !ref->residual) || !ref->depth || !ref->score || !ref->links)
        return GSF_ERROR_OUT_OF_MEMORY;
    const gsf_image color = gsf_wrap_image(ref->color, GSF_F32, width, height, 3);
    const gsf_image bytes = gsf_wrap_image(ref->bytes, GSF_U8, width, height, 3);
    const gsf_image depth = gsf_wrap_image(ref->depth, GSF_F32, width, height, 1);
    GSF__TRY(gsf_convert_image(ctx, &from->color, &color));
    GSF__TRY(gsf_convert_image(ctx, &color, &bytes));
    GSF__TRY(gsf_convert_image(ctx, &from->depth, &depth));
    if (has_residuals) {
        const gsf_image residual = gsf_wrap_image(ref->residual, GSF_F32, width, height, 3);
        GSF__TRY(gsf_convert_image(ctx, &from->render, &residual));
        for (size_t p = 0; p < 3 * pixels; p++) ref->residual[p] = ref->color[p] - ref->residual[p];
    }
    int exact = 1;
    for (size_t p = 0; p < 3 * pixels && exact; p++) exact = (float)(ref->bytes[p] / 255.0) == ref->color[p];
    if (exact) {
        gsf_free(ctx, ref->color);
        ref->color = NULL;
    } else {
        gsf_free(ctx, ref->bytes);
        ref->bytes = NULL;
    }
    gsf__carry_find_focus(ref);
    return GSF_OK;
}

// Depth that stereo confirms at a pixel of the photo, 0 = none. A map that is smaller than the photo is interpolated in
// inverse depth where all four neighbours lie on one surface.
static float gsf__carry_stereo_depth(const gsf__carry_study* study, const gsf_camera* camera, int32_t x, int32_t y) {
    if (!study->depth) return 0.0f;
    if (study->width == camera->width && study->height == camera->height)
        return study->depth[(size_t)y * (size_t)study->width + (size_t)x];
    gsf_camera map;
    gsf__taps taps;
    float v[4], lo = INFINITY, hi = 0.0f;
    memset(&map, 0, sizeof map);
    map.width = study->width;
    map.height = study->height;
    const double u = (x + 0.5) * study->width / camera->width, w = (y + 0.5) * study->height / camera->height;
    if (!gsf__find_taps(&map, u, w, &taps)) return 0.0f;
    for (int k = 0; k < 4; k++) {
        const float depth = study->depth[taps.at[k]];
        if (depth < lo) lo = depth;
        if (depth > hi) hi = depth;
        v[k] = depth > 0.0f ? 1.0f / depth : 0.0f;
    }
    if (lo > 0.0f && hi <= lo * GSF__CARRY_EDGE) return 1.0f / gsf__blend_taps(&taps, v);
    return study->depth[(size_t)w * (size_t)study->width + (size_t)u];
}

// ---- scores

typedef struct gsf__carry_score_job {
    const gsf__carrier* carrier;
    const float* const* grey;  // per reference: (H,W), of the mean exposure
    int32_t reference, other;  // the one that is judged, and by which
    float* seen;               // (H,W) grey of the other photo at the pixel's point
    uint8_t* relation;         // (H,W) GSF__CARRY_NONE...
    uint8_t *support, *refuted, *alike; // (H,W): how many others agree, how many look through, percent of likeness
    const uint8_t* stereo;     // (H,W): whether the depth is that of stereo
} gsf__carry_score_job;

enum { GSF__CARRY_NONE = 0, GSF__CARRY_AGREES, GSF__CARRY_THROUGH, GSF__CARRY_HIDDEN };

static void gsf__carry_look_row(void* arg, size_t row, int32_t worker) { // fills in `seen` and `relation`
    (void)worker;
    const gsf__carry_score_job* job = (const gsf__carry_score_job*)arg;
    const gsf__carry_reference *ref = job->carrier->references + job->reference, *other = job->carrier->references + job->other;
    for (int32_t x = 0; x < ref->camera.width; x++) {
        const size_t at = row * (size_t)ref->camera.width + (size_t)x;
        double point[3], u, v, z;
        gsf__taps taps;
        job->relation[at] = GSF__CARRY_NONE;
        if (!(ref->depth[at] > 0.0f)) continue;
        gsf__unproject(&ref->camera, x + 0.5, (double)row + 0.5, (double)ref->depth[at], point);
        if (!gsf_project_point(&other->camera, point, &u, &v, &z)) continue;
        const float shown = gsf__nearest_depth(other, u, v);
        if (!(shown > 0.0f) || !gsf__find_taps(&other->camera, u, v, &taps)) continue;
        const float off = (float)z / shown - 1.0f;
        job->seen[at] = gsf__sample_floats(job->grey[job->other], 1, 0, &taps);
        job->relation[at] = (uint8_t)(fabsf(off) <= GSF__CARRY_DEPTH_TOLERANCE         ? GSF__CARRY_AGREES
                                      : off < -2.0f * GSF__CARRY_DEPTH_TOLERANCE ? GSF__CARRY_THROUGH
                                                                                  : GSF__CARRY_HIDDEN);
    }
}

// How alike the two photos are around a pixel, over the pixels whose depths agree: 0..100. Windows without texture are alike
// if their brightness is.
static int gsf__carry_likeness(const gsf__carry_score_job* job, int32_t x, int32_t y) {
    const gsf_camera* camera = &job->carrier->references[job->reference].camera;
    const float* grey = job->grey[job->reference];
    float n = 0.0f, a = 0.0f, b = 0.0f, aa = 0.0f, bb = 0.0f, ab = 0.0f;
    for (int32_t v = y - GSF__CARRY_WINDOW; v <= y + GSF__CARRY_WINDOW; v++)
        for (int32_t u = x - GSF__CARRY_WINDOW; u <= x + GSF__CARRY_WINDOW; u++) {
            if (u < 0 || v < 0 || u >= camera->width || v >= camera->height) continue;
            const size_t at = (size_t)v * (size_t)camera->width + (size_t)u;
            if (job->relation[at] != GSF__CARRY_AGREES) continue;
            const float p = grey[at], q = job->seen[at];
            n += 1.0f;
            a += p;
            b += q;
            aa += p * p;
            bb += q * q;
            ab += p * q;
        }
    if (n < 24.0f) return 0;
    const float mean_a = a / n, mean_b = b / n, var_a = aa / n - mean_a * mean_a, var_b = bb / n - mean_b * mean_b;
    const float noise = 0.012f * 0.012f;
    if (var_a < noise && var_b < noise) return fabsf(mean_a - mean_b) < 0.04f ? 60 : 0;
    const float alike = (ab / n - mean_a * mean_b) / sqrtf((var_a + 0.25f * noise) * (var_b + 0.25f * noise));
    return alike > 0.0f ? (int)(100.0f * (alike < 1.0f ? alike : 1.0f)) : 0;
}

static void gsf__carry_judge_row(void* arg, size_t row, int32_t worker) { // adds what the other reference says
    (void)worker;
    const gsf__carry_score_job* job = (const gsf__carry_score_job*)arg;
    const int32_t width = job->carrier->references[job->reference].camera.width;
    for (int32_t x = 0; x < width; x++) {
        const size_t at = row * (size_t)width + (size_t)x;
        job->refuted[at] = (uint8_t)(job->refuted[at] + (job->relation[at] == GSF__CARRY_THROUGH));
        if (job->relation[at] != GSF__CARRY_AGREES) continue;
        const int alike = gsf__carry_likeness(job, x, (int32_t)row);
        job->support[at]++;
        if (alike > job->alike[at]) job->alike[at] = (uint8_t)alike;
    }
}

static void gsf__carry_score_row(void* arg, size_t row, int32_t worker) {
    (void)worker;
    const gsf__carry_score_job* job = (const gsf__carry_score_job*)arg;
    const gsf__carry_reference* ref = job->carrier->references + job->reference;
    for (int32_t x = 0; x < ref->camera.width; x++) {
        const size_t at = row * (size_t)ref->camera.width + (size_t)x;
        const int support = job->support[at], refuted = job->refuted[at], alike = job->alike[at];
        int score = 0;
        if (!(ref->depth[at] > 0.0f)) score = 0;
        else if (job->stereo[at]) score = refuted > support ? 40 : 100;
        else if (refuted > support) score = 5;
        else if (support == 0) score = 30; // no other reference shows the place
        else score = alike >= GSF__CARRY_ALIKE ? 70 : 40;
        ref->score[at] = (uint8_t)score;
    }
}

static int gsf__carry_connected(float a, float b, float c) {
    const float ab = a < b ? a : b, lo = ab < c ? ab : c, over_ab = a < b ? b : a, hi = over_ab < c ? c : over_ab;
    return lo > 0.0f && hi <= lo * GSF__CARRY_EDGE;
}

static void gsf__carry_link_row(void* arg, size_t row, int32_t worker) { // all rows but the last
    (void)worker;
    const gsf__carry_score_job* job = (const gsf__carry_score_job*)arg;
    const gsf__carry_reference* ref = job->carrier->references + job->reference;
    const size_t width = (size_t)ref->camera.width;
    const float *depth = ref->depth + row * width, *below = depth + width;
    for (size_t x = 0; x + 1 < width; x++)
        ref->links[row * width + x] =
            (uint8_t)((gsf__carry_connected(depth[x], depth[x + 1], below[x]) ? GSF__CARRY_UPPER : 0) |
                      (gsf__carry_connected(depth[x + 1], below[x + 1], below[x]) ? GSF__CARRY_LOWER : 0));
}

// Corrects the splats' depth where stereo is silent by the ratio of both around it: the log of the ratio is averaged in a
// pyramid of sums, and every pixel takes it from the finest level that has evidence.
static gsf_result gsf__carry_correct(gsf_context* ctx, gsf__carry_reference* ref, const float* confirmed) {
    gsf__arena arena = {ctx, NULL, 0};
    float *sum[GSF__CARRY_LEVELS], *weight[GSF__CARRY_LEVELS];
    int32_t width[GSF__CARRY_LEVELS], height[GSF__CARRY_LEVELS];
    const float prior = 0.05f; // pixels' worth of evidence that the next coarser level counts for
    for (int l = 0; l < GSF__CARRY_LEVELS; l++) {
        width[l] = l ? (width[l - 1] + 1) / 2 : ref->camera.width;
        height[l] = l ? (height[l - 1] + 1) / 2 : ref->camera.height;
        sum[l] = (float*)gsf__arena_alloc_zeroed(&arena, (size_t)width[l] * (size_t)height[l], sizeof(float));
        weight[l] = (float*)gsf__arena_alloc_zeroed(&arena, (size_t)width[l] * (size_t)height[l], sizeof(float));
    }
    if (arena.failed) {
        gsf__arena_free(&arena);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    const size_t pixels = (size_t)width[0] * (size_t)height[0];
    for (size_t at = 0; at < pixels; at++) {
        if (!(confirmed[at] > 0.0f && ref->depth[at] > 0.0f)) continue;
        const float off = confirmed[at] / ref->depth[at] - 1.0f;
        if (!(fabsf(off) < 0.2f)) continue; // a floater, or the background through a hole
        sum[0][at] = off;
        weight[0][at] = 1.0f;
    }
    for (int l = 1; l < GSF__CARRY_LEVELS; l++)
        for (int32_t y = 0; y < height[l - 1]; y++)
            for (int32_t x = 0; x < width[l - 1]; x++) {
                const size_t from = (size_t)y * (size_t)width[l - 1] + (size_t)x;
                const size_t to = (size_t)(y / 2) * (size_t)width[l] + (size_t)(x / 2);
                sum[l][to] += sum[l - 1][from];
                weight[l][to] += weight[l - 1][from];
            }
    for (int l = GSF__CARRY_LEVELS - 1; l >= 0; l--) // sum becomes the mean at the level
        for (int32_t y = 0; y < height[l]; y++)
            for (int32_t x = 0; x < width[l]; x++) {
                const size_t at = (size_t)y * (size_t)width[l] + (size_t)x;
                float coarse = 0.0f;
                if (l + 1 < GSF__CARRY_LEVELS) {
                    gsf_camera level;
                    gsf__taps taps;
                    memset(&level, 0, sizeof level);
                    level.width = width[l + 1];
                    level.height = height[l + 1];
                    if (gsf__find_taps(&level, 0.5 * (x + 0.5), 0.5 * (y + 0.5), &taps))
                        coarse = gsf__sample_floats(sum[l + 1], 1, 0, &taps);
                }
                sum[l][at] = (sum[l][at] + prior * coarse) / (weight[l][at] + prior);
            }
    for (size_t at = 0; at < pixels; at++) ref->depth[at] *= 1.0f + sum[0][at];
    gsf__arena_free(&arena);
    return GSF_OK;
}

// Replaces the depth of every reference by that of stereo where there is one, and scores all pixels.
static gsf_result gsf__carrier_score(gsf_context* ctx, gsf__carrier* carrier) {
    gsf__arena arena = {ctx, NULL, 0};
    gsf__carry_score_job job;
    size_t most = 0;
    float** grey = (float**)gsf__arena_alloc_zeroed(&arena, (size_t)carrier->count, sizeof *grey);
    for (int32_t i = 0; i < carrier->count && grey; i++) {
        const gsf_camera* camera = &carrier->references[i].camera;
        const size_t pixels = (size_t)camera->width * (size_t)camera->height;
        if (pixels > most) most = pixels;
        grey[i] = (float*)gsf__arena_alloc(&arena, pixels, sizeof(float));
    }
    uint8_t** stereo = (uint8_t**)gsf__arena_alloc_zeroed(&arena, (size_t)carrier->count, sizeof *stereo);
    for (int32_t i = 0; i < carrier->count && stereo; i++)
        stereo[i] = (uint8_t*)gsf__arena_alloc_zeroed(&arena, (size_t)carrier->references[i].camera.width *
                                                               (size_t)carrier->references[i].camera.height, 1);
    memset(&job, 0, sizeof job);
    job.carrier = carrier;
    job.grey = (const float* const*)grey;
    job.seen = (float*)gsf__arena_alloc(&arena, most, sizeof(float));
    job.relation = (uint8_t*)gsf__arena_alloc(&arena, most, 1);
    job.support = (uint8_t*)gsf__arena_alloc(&arena, most, 3);
    if (arena.failed) {
        gsf__arena_free(&arena);
        return GSF_ERROR_OUT_OF_MEMORY;
    }
    gsf_result result = GSF_OK;
    float* confirmed = job.seen;
    gsf__carry_set_exposure(carrier, NULL);
    job.refuted = job.support + most;
    job.alike = job.refuted + most;
    for (int32_t i = 0; i < carrier->count && result == GSF_OK; i++) {
        gsf__carry_reference* ref = carrier->references + i;
        const int32_t width = ref->camera.width, height = ref->camera.height;
        const gsf__carry_study* study = i < carrier->study_count ? carrier->studies + i : NULL;
        for (int32_t y = 0; y < height; y++)
            for (int32_t x = 0; x < width; x++)
                confirmed[(size_t)y * (size_t)width + (size_t)x] =
                    study ? gsf__carry_stereo_depth(study, &ref->camera, x, y) : 0.0f;
        if (study && study->depth) result = gsf__carry_correct(ctx, ref, confirmed);
        for (int32_t y = 0; y < height; y++)
            for (int32_t x = 0; x < width; x++) {
                const size_t at = (size_t)y * (size_t)width + (size_t)x;
                float rgb[3];
                gsf__carry_pixel(carrier, i, at, rgb);
                grey[i][at] = 0.299f * rgb[0] + 0.587f * rgb[1] + 0.114f * rgb[2];
                stereo[i][at] = confirmed[at] > 0.0f;
                if (stereo[i][at]) ref->depth[at] = confirmed[at];
            }
    }
    for (int32_t i = 0; i < carrier->count && result == GSF_OK; i++) {
        const gsf__carry_reference* ref = carrier->references + i;
        const size_t rows = (size_t)ref->camera.height;
        int32_t others[GSF__CARRY_OTHERS + 1];
        const int count = gsf__carry_nearest(carrier, ref->center, others, GSF__CARRY_OTHERS + 1);
        job.reference = i;
        job.stereo = stereo[i];
        memset(job.support, 0, 3 * most);
        for (int k = 0; k < count; k++) {
            job.other = others[k];
            if (job.other == i) continue;
            gsf__parallel_for(ctx, rows, gsf__carry_look_row, &job);
            gsf__parallel_for(ctx, rows, gsf__carry_judge_row, &job);
        }
        gsf__parallel_for(ctx, rows, gsf__carry_score_row, &job);
        gsf__parallel_for(ctx, rows - 1, gsf__carry_link_row, &job);
    }
    gsf__arena_free(&arena);
    return result;
}

// Copies the references. After an error the carrier is closed.
static gsf_result gsf__carrier_take(gsf_context* ctx, gsf__carrier* carrier, const gsf_reference* references, int32_t count) {
    carrier->references = (gsf__carry_reference*)gsf_alloc_zeroed(ctx, (size_t)count, sizeof(gsf__carry_reference));
    if (!carrier->references) return GSF_ERROR_OUT_OF_MEMORY;
    carrier->count = count;
    carrier->has_residuals = 1;
    gsf_result result = GSF_OK;
    for (int32_t i = 0; i < count; i++) carrier->has_residuals &= references[i].render.data != NULL;
    for (int32_t i = 0; i < count && result == GSF_OK; i++)
        result = gsf__carry_take(ctx, references + i, carrier->has_residuals, carrier->references + i);
    if (result != GSF_OK) gsf__carrier_close(ctx, carrier);
    return result;
}

// ---- one frame

typedef struct gsf__carry_vertex { float u, v, inv_z; } gsf__carry_vertex; // inv_z 0: no surface
typedef struct gsf__carry_span { float lo, hi; } gsf__carry_span;          // of u or v

static gsf__carry_span gsf__carry_span_of(float a, float b, float c) {
    const gsf__carry_span ab = {a < b ? a : b, a < b ? b : a}, all = {ab.lo < c ? ab.lo : c, ab.hi < c ? c : ab.hi};
    return all;
}

// Pixels whose centres lie in lo..hi, and those that are less than 0.01 off.
static void gsf__carry_range(float lo, float hi, int32_t begin, int32_t end, int32_t* first, int32_t* last) {
    *first = lo > (float)begin + 0.51f ? (int32_t)(lo + 0.49f) : begin;
    *last = hi < (float)end - 0.51f ? (int32_t)(hi + 0.51f) - 1 : end - 1;
}

// Rasterizes a triangle of inverse depths into the rows begin..end-1 of the z-buffer (the largest inverse depth wins).
// Triangles that face away or are stretched over more than 32 pixels are skipped: they are not a surface that the
// reference saw.
static void gsf__carry_triangle(const gsf__carry_vertex* a, const gsf__carry_vertex* b, const gsf__carry_vertex* c,
                                float* inv_z, int32_t width, int32_t begin, int32_t end) {
    const gsf__carry_span v = gsf__carry_span_of(a->v, b->v, c->v);
    if (!(v.hi > (float)begin && v.lo < (float)end)) return;
    const gsf__carry_span u = gsf__carry_span_of(a->u, b->u, c->u);
    if (!(u.hi > 0.0f && u.lo < (float)width) || u.hi - u.lo > 32.0f || v.hi - v.lo > 32.0f) return;
    const float area = (b->u - a->u) * (c->v - a->v) - (b->v - a->v) * (c->u - a->u);
    if (!(area > 1e-6f)) return;
    int32_t x0, x1, y0, y1;
    gsf__carry_range(u.lo, u.hi, 0, width, &x0, &x1);
    gsf__carry_range(v.lo, v.hi, begin, end, &y0, &y1);
    const float scale = 1.0f / area;
    for (int32_t y = y0; y <= y1; y++)
        for (int32_t x = x0; x <= x1; x++) {
            const float px = (float)x + 0.5f, py = (float)y + 0.5f;
            const float wb = ((px - a->u) * (c->v - a->v) - (py - a->v) * (c->u - a->u)) * scale;
            const float wc = ((b->u - a->u) * (py - a->v) - (b->v - a->v) * (px - a->u)) * scale;
            const float wa = 1.0f - wb - wc;
            if (wa < -1e-4f || wb < -1e-4f || wc < -1e-4f) continue;
            const float value = wa * a->inv_z + wb * b->inv_z + wc * c->inv_z;
            float* at = inv_z + (size_t)y * (size_t)width + (size_t)x;
            if (value > *at) *at = value;
        }
}

typedef struct gsf__carry_draw_job {
    const gsf__carry_reference* ref;
    const gsf_camera* camera;    // of the frame
    gsf__carry_vertex* vertices; // (H,W) of the reference
    gsf__carry_span* spans;      // (H), of the v of a row of vertices
    float* inv_z;                // (H,W) of the frame
} gsf__carry_draw_job;

static void gsf__carry_vertex_row(void* arg, size_t row, int32_t worker) {
    (void)worker;
    const gsf__carry_draw_job* job = (const gsf__carry_draw_job*)arg;
    const gsf_camera* from = &job->ref->camera;
    gsf__carry_vertex* vertices = job->vertices + row * (size_t)from->width;
    const float* depth = job->ref->depth + row * (size_t)from->width;
    const uint8_t* score = job->ref->score + row * (size_t)from->width;
    gsf__carry_span span = {INFINITY, -INFINITY};
    for (int32_t x = 0; x < from->width; x++) {
        double point[3], u, v, z;
        vertices[x].inv_z = 0.0f;
        if (!(depth[x] > 0.0f) || score[x] == 0) continue;
        gsf__unproject(from, x + 0.5, (double)row + 0.5, (double)depth[x], point);
        if (!gsf_project_point(job->camera, point, &u, &v, &z)) continue;
        vertices[x].u = (float)u;
        vertices[x].v = (float)v;
        vertices[x].inv_z = (float)(1.0 / z);
        if (vertices[x].v < span.lo) span.lo = vertices[x].v;
        if (vertices[x].v > span.hi) span.hi = vertices[x].v;
    }
    job->spans[row] = span;
}

static void gsf__carry_draw_band(void* arg, size_t band, int32_t worker) {
    (void)worker;
    const gsf__carry_draw_job* job = (const gsf__carry_draw_job*)arg;
    const int32_t width = job->ref->camera.width, begin = (int32_t)band * GSF__CARRY_BAND;
    const int32_t end = begin + GSF__CARRY_BAND < job->camera->height ? begin + GSF__CARRY_BAND : job->camera->height;
    for (int32_t y = 0; y + 1 < job->ref->camera.height; y++) {
        const gsf__carry_span *up = job->spans + y, *down = up + 1;
        if (!((up->hi > (float)begin || down->hi > (float)begin) && (up->lo < (float)end || down->lo < (float)end))) continue;
        const gsf__carry_vertex *above = job->vertices + (size_t)y * (size_t)width, *below = above + width;
        const uint8_t* links = job->ref->links + (size_t)y * (size_t)width;
        for (int32_t x = 0; x + 1 < width; x++) {
            const gsf__carry_vertex *a = above + x, *b = a + 1, *c = below + x, *d = c + 1;
            if (!links[x] || !(b->inv_z > 0.0f && c->inv_z > 0.0f)) continue; // both triangles have them
            if ((links[x] & GSF__CARRY_UPPER) && a->inv_z > 0.0f)
                gsf__carry_triangle(a, b, c, job->inv_z, job->camera->width, begin, end);
            if ((links[x] & GSF__CARRY_LOWER) && d->inv_z > 0.0f)
                gsf__carry_triangle(b, d, c, job->inv_z, job->camera->width, begin, end);
        }
    }
}

// Draws `count` references into z-buffers of the frame, carrier->inv_z + slot * pixels.
static gsf_result gsf__carrier_draw(gsf_context* ctx, gsf__carrier* carrier, const gsf_camera* camera, const int32_t* nearest,
                                    int count) {
    const size_t plane = (size_t)camera->width * (size_t)camera->height;
    size_t room = 0;
    for (int k = 0; k < count; k++) {
        const gsf_camera* from = &carrier->references[nearest[k]].camera;
        const size_t bytes = (size_t)from->width * (size_t)from->height * sizeof(gsf__carry_vertex) +
                             (size_t)from->height * sizeof(gsf__carry_span);
        if (bytes > room) room = bytes;
    }
    GSF__TRY(gsf__reserve(ctx, &carrier->vertices, &carrier->vertex_capacity, 0, room, 1));
    GSF__TRY(gsf__reserve(ctx, (void**)&carrier->inv_z, &carrier->inv_z_capacity, 0, plane * (size_t)count, sizeof(float)));
    memset(carrier->inv_z, 0, plane * (size_t)count * sizeof(float));
    double center[3];
    gsf_get_camera_center(camera, center);
    gsf__carry_set_exposure(carrier, center);
    for (int k = 0; k < count; k++) {
        gsf__carry_draw_job job;
        job.ref = carrier->references + nearest[k];
        job.camera = camera;
        job.vertices = (gsf__carry_vertex*)carrier->vertices;
        job.spans = (gsf__carry_span*)(void*)(job.vertices + (size_t)job.ref->camera.width * (size_t)job.ref->camera.height);
        job.inv_z = carrier->inv_z + (size_t)k * plane;
        gsf__parallel_for(ctx, (size_t)job.ref->camera.height, gsf__carry_vertex_row, &job);
        gsf__parallel_for(ctx, (size_t)((camera->height + GSF__CARRY_BAND - 1) / GSF__CARRY_BAND), gsf__carry_draw_band, &job);
    }
    return GSF_OK;
}

typedef struct gsf__carry_sample { // what a reference shows at a pixel of a frame
    gsf__taps taps; // in the reference
    float depth;    // camera depth in the frame
    float score;    // [0,1]
    float angle2;   // squared angle between the rays to the frame and to the reference, radians
} gsf__carry_sample;

// Returns 0 where the reference shows nothing.
static int gsf__carry_sample_at(const gsf__carry_reference* ref, const gsf_camera* camera, const double center[3], int32_t x,
                                int32_t y, float inv_z, gsf__carry_sample* out) {
    double point[3], u, v, z;
    if (!(inv_z > 0.0f)) return 0;
    gsf__unproject(camera, x + 0.5, y + 0.5, 1.0 / (double)inv_z, point);
    if (!gsf_project_point(&ref->camera, point, &u, &v, &z)) return 0;
    if (!gsf__find_taps(&ref->camera, u, v, &out->taps)) return 0;
    out->score = gsf__sample_bytes(ref->score, 1, 0, 100.0, &out->taps);
    if (!(out->score > 0.0f)) return 0;
    const double cosine = gsf__ray_cosine(point, center, ref->center);
    const float chord2 = (float)(2.0 - 2.0 * (cosine < 1.0 ? cosine : 1.0));
    out->angle2 = chord2 * (1.0f + chord2 * (1.0f / 12.0f + chord2 * (1.0f / 90.0f))); // (2 asin(chord / 2))^2
    out->depth = (float)(1.0 / (double)inv_z);
    return 1;
}

typedef struct gsf__carry_job {
    const gsf__carrier* carrier;
    const gsf_camera* camera;
    double center[3];
    int32_t reference;
    const gsf_image* depth;                       // of the frame
    const gsf_image* images[GSF__CARRIED_IMAGES]; // in the order of gsf_carried
} gsf__carry_job;

static void gsf__carry_row(void* arg, size_t row, int32_t worker) {
    (void)worker;
    const gsf__carry_job* job = (const gsf__carry_job*)arg;
    const gsf_camera* camera = job->camera;
    const gsf__carry_reference* ref = job->carrier->references + job->reference;
    const int32_t y = (int32_t)row;
    for (int32_t x = 0; x < camera->width; x++) {
        gsf__carry_sample s;
        double point[3], u, v, z;
        float color[3] = {0.0f, 0.0f, 0.0f}, residual[3] = {0.0f, 0.0f, 0.0f}, back[3] = {0.0f, 0.0f, 0.0f}, ratio = 0.0f;
        const int shows = gsf__carry_sample_at(ref, camera, job->center, x, y,
                                               job->carrier->inv_z[row * (size_t)camera->width + (size_t)x], &s);
        for (int c = 0; c < 3 && shows; c++) {
            color[c] = gsf__carry_color(job->carrier, job->reference, (size_t)c, &s.taps);
            if (job->carrier->has_residuals) residual[c] = gsf__sample_floats(ref->residual, 3, (size_t)c, &s.taps);
        }
        const float own = gsf__get_pixel(job->depth, x, y, 0);
        gsf__taps taps;
        if (own > 0.0f) {
            gsf__unproject(camera, x + 0.5, y + 0.5, (double)own, point);
            if (gsf_project_point(&ref->camera, point, &u, &v, &z) && gsf__find_taps(&ref->camera, u, v, &taps)) {
                const float there = gsf__nearest_depth(ref, u, v);
                ratio = there > 0.0f ? (float)z / there : 0.0f;
                for (int c = 0; c < 3; c++) back[c] = gsf__carry_color(job->carrier, job->reference, (size_t)c, &taps);
            }
        }
        for (int c = 0; c < 3; c++) {
            gsf__put_pixel(job->images[0], x, y, c, color[c]);
            gsf__put_pixel(job->images[1], x, y, c, residual[c]);
            gsf__put_pixel(job->images[5], x, y, c, back[c]);
        }
        gsf__put_pixel(job->images[2], x, y, 0, shows ? s.score : 0.0f);
        gsf__put_pixel(job->images[3], x, y, 0, shows ? s.depth : 0.0f);
        gsf__put_pixel(job->images[4], x, y, 0, shows ? sqrtf(s.angle2) : 0.0f);
        gsf__put_pixel(job->images[6], x, y, 0, ratio);
    }
}

// Fills in *out, whose images exist at the frame's size. depth: of the frame.
static gsf_result gsf__carrier_carry(gsf_context* ctx, gsf__carrier* carrier, const gsf_camera* camera, const gsf_image* depth,
                                     int32_t slot, gsf_carried* out) {
    gsf__carry_job job;
    gsf_image* images[GSF__CARRIED_IMAGES];
    int32_t channels[GSF__CARRIED_IMAGES], nearest[GSF__CARRY_SLOTS];
    gsf__list_carried(out, images, channels);
    memset(&job, 0, sizeof job);
    job.carrier = carrier;
    job.camera = camera;
    job.depth = depth;
    for (int k = 0; k < GSF__CARRIED_IMAGES; k++) job.images[k] = images[k];
    gsf_get_camera_center(camera, job.center);
    const int count = gsf__carry_nearest(carrier, job.center, nearest, slot + 1);
    out->reference = slot < count ? nearest[slot] : -1;
    if (slot >= count) {
        for (int k = 0; k < GSF__CARRIED_IMAGES; k++)
            memset(images[k]->data, 0, (size_t)camera->width * (size_t)camera->height * (size_t)channels[k] * sizeof(float));
        return GSF_OK;
    }
    job.reference = nearest[slot];
    GSF__TRY(gsf__carrier_draw(ctx, carrier, camera, nearest + slot, 1));
    gsf__parallel_for(ctx, (size_t)camera->height, gsf__carry_row, &job);
    return GSF_OK;
}

static gsf_result gsf__fit_image(gsf_context* ctx, gsf_image* image, const gsf_camera* camera, int32_t channels) {
    if (image->data && image->width == camera->width && image->height == camera->height) return GSF_OK;
    gsf_destroy_image(ctx, image);
    return gsf_make_image(ctx, GSF_F32, camera->width, camera->height, channels, image);
}

// A carrier lent to a restorer for one window.
typedef struct gsf__carry_loan {
    gsf__carrier* carrier;
    int32_t frame_count, slot_count;
    const gsf_camera* cameras;  // of the frames
    const gsf_image* depth;
    gsf_image images[GSF__CARRIED_IMAGES]; // made on demand, in the order of gsf_carried
} gsf__carry_loan;

static void gsf__carry_end_loan(gsf_context* ctx, gsf__carry_loan* loan) {
    for (int k = 0; k < GSF__CARRIED_IMAGES; k++) gsf_destroy_image(ctx, loan->images + k);
    memset(loan, 0, sizeof *loan);
}

// carry_fn of the loop's windows.
static gsf_result gsf__carry_for_window(void* user, gsf_context* ctx, int32_t frame, int32_t slot, gsf_carried* out) {
    gsf__carry_loan* loan = (gsf__carry_loan*)user;
    gsf_image* images[GSF__CARRIED_IMAGES];
    int32_t channels[GSF__CARRIED_IMAGES];
    if (frame < 0 || frame >= loan->frame_count || slot < 0 || slot >= loan->slot_count)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "carry: frame %d of %d, reference %d of %d", (int)frame,
                        (int)loan->frame_count, (int)slot, (int)loan->slot_count);
    const gsf_camera* camera = loan->cameras + frame;
    memset(out, 0, sizeof *out);
    gsf__list_carried(out, images, channels);
    for (int k = 0; k < GSF__CARRIED_IMAGES; k++) {
        GSF__TRY(gsf__fit_image(ctx, loan->images + k, camera, channels[k]));
        *images[k] = loan->images[k];
        images[k]->owned = NULL;
    }
    return gsf__carrier_carry(ctx, loan->carrier, camera, loan->depth + frame, slot, out);
}

// ---- >>warp --------------------------------------------------------------------

/* Training-free restorer: shows in a frame what the references (>>carry) explain of it. Per pixel, the candidates of the
   nearest references are grouped by depth, and the nearest group with enough weight wins (occlusion).
       verified    A candidate whose depth and colour another photo confirms is right information. If there are few photos
                   or the frame shows another depth, its colour, at the exposure of the photos around, replaces the render;
                   else its residual is added in full, which keeps the render's shading (colours instead: +0.2 dB with
                   three photos, -0.2 dB with six). Candidates of the same group that are not verified are left out.
       supported   Where only the splats vouch for the depth, a carried photo would displace all detail by the depth error
                   and bring its shading along. The residual, photo - render at the photo's own camera, is what the splats
                   do not yet explain; it is added to the render.
       floaters    A residual would keep a floater: where two references look through the surface that the frame shows and
                   none sees it there, the colours are taken even so, unless photos are few.
       in front    What references show in front of the frame's surface counts a tenth: the splats are trained on photos that
                   look through there, and with many photos its depth is mostly wrong.
       hidden      What references show far behind the surface of the frame is most likely hidden by it, unless one of them
                   looks through that surface: the render is kept. With few photos, surfaces little in front hide, too, and
                   two references have to look through them; what is behind counts half then.
   Blending is weighted by score and angle; confidence falls where the candidates disagree. Pixels that no reference
   reaches keep the render and get confidence 0, so that they are not trained on.
   In the repair loop it shares the loop's carrier; elsewhere it makes one of its own from the references. If a reference has
   no render, colours are taken everywhere. */

typedef struct gsf__warp {
    gsf__carrier own;  // the references, until the first window tells that the host carries
    int begun, ready;  // ready: `own` is studied and scored
} gsf__warp;

#define GSF__WARP_ANGLE 0.2f            // radians: a reference whose viewing direction differs by this weighs exp(-1/2)
#define GSF__WARP_GROUP_SHARE 0.35f     // share of the heaviest group's weight that a nearer group needs to occlude it
#define GSF__WARP_TRUST 0.5f            // total weight below which a residual is attenuated
#define GSF__WARP_BEHIND_MIN 1.02f      // range of depth ratios in which a warped surface counts as behind the frame's
#define GSF__WARP_BEHIND_MAX 2.0f
#define GSF__WARP_HIDDEN 1.1f           // depth ratio from which a warped surface may be hidden by the frame's
#define GSF__WARP_HIDDEN_FEW (1.0f + GSF__CARRY_DEPTH_TOLERANCE) // the same with few photos: any other surface
#define GSF__WARP_OPAQUE 0.5f           // alpha from which the frame's surface hides others
#define GSF__WARP_IN_FRONT 0.1f         // confidence of what is in front of the frame's surface
#define GSF__WARP_FLOATER 0.5f          // confidence of what is behind a floater, with few photos
#define GSF__WARP_CLEARANCE 4.0         // pixels: a reference must look through this neighbourhood of a point, too
enum { GSF__WARP_NEAREST = 4 };         // number of references carried into a frame
enum { GSF__WARP_HALVED = 256 };        // photos of at least this many pixels a side are repaired at half their size
enum { GSF__WARP_FEW = 6 };             // fewer photos are few: their verified colours replace the render everywhere

static gsf_result gsf__warp_query(void* user, gsf_context* ctx, int32_t frame_count, int32_t width, int32_t height,
                                  gsf_restorer_info* out) {
    const gsf__warp* warp = (const gsf__warp*)user;
    (void)ctx;
    out->needs_depth = 1;
    out->needs_alpha = 1;
    out->explains = 1;
    if (out->struct_size >= sizeof *out) {
        out->needs_carried = GSF__WARP_NEAREST;
        // Weight 1 gains no more, but leaves some scenes below those without repair. More photos show more, so that repair
        // adds less to them. Measured in bench/TRIED.md
        out->lambda = 0.5f;
        out->lambda_views = 6;
        // Whole frames cost more and gain the same, as the photos show all detail; halved ones of small photos are too coarse.
        // Measured in bench/TRIED.md
        if (width >= GSF__WARP_HALVED && height >= GSF__WARP_HALVED) out->frame_scale = 0.5f;
    }
    const int32_t count = warp->own.count > 0 ? warp->own.count : 3;
    const int32_t drawn = count < GSF__WARP_NEAREST ? count : GSF__WARP_NEAREST;
    out->bytes = (double)width * height * (20.0 * count + 4.0 * drawn + 12.0);
    out->flops = (double)width * height * frame_count * 200.0 * drawn;
    return GSF_OK;
}

static void gsf__warp_end(void* user, gsf_context* ctx) {
    gsf__warp* warp = (gsf__warp*)user;
    gsf__carrier_forget(ctx, &warp->own);
    warp->ready = warp->begun = 0;
}

static gsf_result gsf__warp_begin(void* user, gsf_context* ctx, const gsf_reference* references, int32_t count) {
    gsf__warp* warp = (gsf__warp*)user;
    if (count < 1) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "warp: no references");
    if (warp->begun) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "warp: in use by a run that has not ended");
    for (int32_t i = 0; i < count; i++)
        if (!references[i].color.data || !references[i].depth.data)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "warp: reference %d needs colour and depth", (int)i);
    GSF__TRY(gsf__carrier_take(ctx, &warp->own, references, count));
    warp->begun = 1;
    return GSF_OK;
}

// Every eighth pixel's point in each direction, of all references, to guide stereo.
static double* gsf__warp_points(gsf_context* ctx, const gsf__carrier* carrier, size_t* count) {
    size_t room = 1;
    for (int32_t i = 0; i < carrier->count; i++) {
        const gsf_camera* camera = &carrier->references[i].camera;
        room += (size_t)(camera->width / 8 + 1) * (size_t)(camera->height / 8 + 1);
    }
    double* points = (double*)gsf_alloc(ctx, room, 3 * sizeof *points);
    *count = 0;
    for (int32_t i = 0; i < carrier->count && points; i++) {
        const gsf__carry_reference* ref = carrier->references + i;
        for (int32_t y = 4; y < ref->camera.height; y += 8)
            for (int32_t x = 4; x < ref->camera.width; x += 8) {
                const float depth = ref->depth[(size_t)y * (size_t)ref->camera.width + (size_t)x];
                if (depth > 0.0f)
                    gsf__unproject(&ref->camera, x + 0.5, y + 0.5, (double)depth, points + 3 * (*count)++);
            }
    }
    return points;
}

// Makes `own` ready to be drawn.
static gsf_result gsf__warp_study(gsf_context* ctx, gsf__warp* warp) {
    gsf__carrier* carrier = &warp->own;
    size_t point_count;
    if (warp->ready) return GSF_OK;
    double* points = gsf__warp_points(ctx, carrier, &point_count);
    gsf_scene_view* views = (gsf_scene_view*)gsf_alloc_zeroed(ctx, (size_t)carrier->count, sizeof *views);
    gsf_result result = points && views ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (int32_t i = 0; i < carrier->count && views; i++) {
        gsf__carry_reference* ref = carrier->references + i;
        void* pixels = ref->bytes ? (void*)ref->bytes : (void*)ref->color;
        views[i].camera = ref->camera;
        views[i].image = gsf_wrap_image(pixels, ref->bytes ? GSF_U8 : GSF_F32, ref->camera.width, ref->camera.height, 3);
    }
    if (result == GSF_OK && !carrier->studies)
        result = gsf__carrier_study(ctx, carrier, views, carrier->count, points, point_count, 0);
    if (result == GSF_OK) result = gsf__carrier_score(ctx, carrier);
    if (result == GSF_OK) warp->ready = 1;
    gsf_free(ctx, points);
    gsf_free(ctx, views);
    return result;
}

typedef struct gsf__warp_job {
    const gsf__carrier* carrier;
    const gsf_restore_window* window;
    int32_t frame, known;  // known: the reference whose own view the frame is, or -1
    double center[3];
    int32_t nearest[GSF__WARP_NEAREST];
    int near_count;
} gsf__warp_job;

// Returns how many references look through the surface that the frame shows at camera depth `z`: 0 if one of them shows a
// surface at that depth within GSF__WARP_CLEARANCE (tolerance for leaves and edges). Two make it a floater.
static int gsf__warp_count_through(const gsf__warp_job* job, const gsf_camera* camera, int32_t x, int32_t y, double z) {
    int through = 0;
    double point[3], u, v, depth;
    gsf__unproject(camera, x + 0.5, y + 0.5, z, point);
    for (int k = 0; k < job->near_count; k++) {
        const gsf__carry_reference* ref = job->carrier->references + job->nearest[k];
        if (!gsf_project_point(&ref->camera, point, &u, &v, &depth)) continue;
        int behind = 0;
        for (int i = 0; i < 9; i++) {
            const double at_u = u + GSF__WARP_CLEARANCE * (i % 3 - 1), at_v = v + GSF__WARP_CLEARANCE * (i / 3 - 1);
            const float seen = gsf__nearest_depth(ref, at_u, at_v);
            if (!(seen > 0.0f)) continue;
            const float off = (float)depth / seen - 1.0f;
            if (fabsf(off) <= GSF__CARRY_DEPTH_TOLERANCE) return 0;
            behind += off < 0.0f;
        }
        through += behind == 9;
    }
    return through;
}

typedef struct gsf__warp_candidate {
    gsf__carry_sample sample;
    int32_t reference;
    float weight;
} gsf__warp_candidate;

// The depth of the nearest group of candidates that is heavy enough to hide those behind it.
static float gsf__warp_front(const gsf__warp_candidate* candidates, int count) {
    float heaviest = 0.0f, front = 0.0f, group[GSF__WARP_NEAREST];
    for (int i = 0; i < count; i++) {
        const float depth = candidates[i].sample.depth;
        group[i] = 0.0f;
        for (int j = 0; j < count; j++)
            if (fabsf(candidates[j].sample.depth - depth) <= GSF__CARRY_DEPTH_TOLERANCE * depth)
                group[i] += candidates[j].weight;
        if (group[i] > heaviest) heaviest = group[i];
    }
    for (int i = 0; i < count; i++)
        if (group[i] >= GSF__WARP_GROUP_SHARE * heaviest && (front == 0.0f || candidates[i].sample.depth < front))
            front = candidates[i].sample.depth;
    return front;
}

// Restores one pixel, whose render is rgb at depth `shown`, from the references. Returns the confidence; if no
// reference reaches the pixel, or what they show is hidden there, returns 0 and leaves rgb unchanged.
static float gsf__warp_pixel(const gsf__warp_job* job, const gsf_camera* camera, int32_t x, int32_t y, const float* inv_z,
                             size_t plane, float shown, int opaque, float rgb[3]) {
    gsf__warp_candidate candidates[GSF__WARP_NEAREST];
    int count = 0, verified = 0;
    for (int k = 0; k < job->near_count; k++) {
        gsf__warp_candidate* at = candidates + count;
        at->reference = job->nearest[k];
        if (!gsf__carry_sample_at(job->carrier->references + at->reference, camera, job->center, x, y,
                                  inv_z[(size_t)k * plane], &at->sample))
            continue;
        at->weight = at->sample.score * gsf__exp(-0.5f * at->sample.angle2 / (GSF__WARP_ANGLE * GSF__WARP_ANGLE)) + 1e-6f;
        count++;
    }
    if (count == 0) return 0.0f;
    const float front = gsf__warp_front(candidates, count);
    for (int i = 0; i < count; i++)
        verified |= fabsf(candidates[i].sample.depth - front) <= GSF__CARRY_DEPTH_TOLERANCE * front &&
                    candidates[i].sample.score >= 0.01f * (float)GSF__CARRY_VERIFIED;
    const int few = job->carrier->count < GSF__WARP_FEW;
    const int agrees = fabsf(front - shown) <= GSF__CARRY_DEPTH_TOLERANCE * shown;
    const int behind = !few && !verified && front > shown * GSF__WARP_BEHIND_MIN && front < shown * GSF__WARP_BEHIND_MAX;
    const int hidden = opaque && shown > 0.0f && front > shown * (few ? GSF__WARP_HIDDEN_FEW : GSF__WARP_HIDDEN);
    const int through = hidden || behind ? gsf__warp_count_through(job, camera, x, y, (double)shown) : 0;
    if (hidden && through < (few ? 2 : 1)) return 0.0f;
    const int refuted = behind && through >= 2;
    const int colors = refuted || (verified && (few || !agrees)) || !job->carrier->has_residuals;
    float total = 0.0f, sum[3] = {0.0f, 0.0f, 0.0f}, square = 0.0f;
    for (int i = 0; i < count; i++) {
        const gsf__warp_candidate* at = candidates + i;
        if (!(fabsf(at->sample.depth - front) <= GSF__CARRY_DEPTH_TOLERANCE * front)) continue;
        if (verified && at->sample.score < 0.01f * (float)GSF__CARRY_VERIFIED) continue;
        total += at->weight;
        for (size_t c = 0; c < 3; c++) {
            const float value = colors ? gsf__carry_color(job->carrier, at->reference, c, &at->sample.taps)
                                       : gsf__sample_floats(job->carrier->references[at->reference].residual, 3, c,
                                                            &at->sample.taps);
            sum[c] += at->weight * value;
            square += at->weight * value * value;
        }
    }
    float spread = square / total;
    for (int c = 0; c < 3; c++) spread -= sum[c] / total * (sum[c] / total);
    const float agreement = gsf__exp(-fmaxf(spread, 0.0f) / (3.0f * 0.15f * 0.15f));
    for (int c = 0; c < 3; c++)
        rgb[c] = colors ? sum[c] / total : rgb[c] + sum[c] / (verified ? total : fmaxf(total, GSF__WARP_TRUST));
    const int in_front = opaque && !agrees && front < shown;
    const float trust = in_front ? GSF__WARP_IN_FRONT : few && hidden ? GSF__WARP_FLOATER : 1.0f;
    return trust * (verified || refuted || total > 1.0f ? 1.0f : total) * agreement;
}

static void gsf__warp_row(void* arg, size_t row, int32_t worker) {
    (void)worker;
    const gsf__warp_job* job = (const gsf__warp_job*)arg;
    const gsf_restore_window* window = job->window;
    const gsf_camera* camera = window->cameras + job->frame;
    const size_t plane = (size_t)camera->width * (size_t)camera->height;
    const int32_t y = (int32_t)row;
    for (int32_t x = 0; x < camera->width; x++) {
        float rgb[3], weight;
        for (int c = 0; c < 3; c++) rgb[c] = gsf__get_pixel(window->color + job->frame, x, y, c);
        if (job->known >= 0) { // use its photo
            const gsf__carry_reference* ref = job->carrier->references + job->known;
            const double u = (x + 0.5 - camera->cx) / camera->fx * ref->camera.fx + ref->camera.cx;
            const double v = (y + 0.5 - camera->cy) / camera->fy * ref->camera.fy + ref->camera.cy;
            weight = u >= 0.0 && v >= 0.0 && u < ref->camera.width && v < ref->camera.height ? 1.0f : 0.0f;
            gsf__taps taps;
            const int inside = gsf__find_taps(&ref->camera, u, v, &taps);
            for (size_t c = 0; c < 3 && weight > 0.0f; c++) rgb[c] = inside ? gsf__photo_color(ref, c, &taps) : 0.0f;
        } else {
            const float shown = window->depth ? gsf__get_pixel(window->depth + job->frame, x, y, 0) : 0.0f;
            const int opaque = !window->alpha || gsf__get_pixel(window->alpha + job->frame, x, y, 0) >= GSF__WARP_OPAQUE;
            weight = gsf__warp_pixel(job, camera, x, y, job->carrier->inv_z + row * (size_t)camera->width + (size_t)x, plane,
                                     shown, opaque, rgb);
        }
        for (int c = 0; c < 3; c++) gsf__put_pixel(window->out_color + job->frame, x, y, c, rgb[c]);
        gsf__put_pixel(window->out_confidence + job->frame, x, y, 0, weight);
    }
}

static gsf_result gsf__warp_restore(void* user, gsf_context* ctx, const gsf_restore_window* window) {
    gsf__warp* warp = (gsf__warp*)user;
    gsf__carrier* carrier = &warp->own;
    if (window->frame_count < 1) return GSF_OK;
    if (gsf__carry_fn_of(window) == gsf__carry_for_window) { // the loop's: no copies of the references are needed
        carrier = ((gsf__carry_loan*)window->carry_user)->carrier;
        gsf__carrier_close(ctx, &warp->own);
    } else {
        GSF__TRY(gsf__warp_study(ctx, warp));
    }
    for (int32_t f = 0; f < window->frame_count; f++) {
        const gsf_camera* camera = window->cameras + f;
        GSF__TRY(gsf_check_camera(ctx, camera));
        GSF__TRY(gsf__check_output(ctx, window->color + f, "color", 3, camera));
        GSF__TRY(gsf__check_output(ctx, window->out_color + f, "out_color", 3, camera));
        GSF__TRY(gsf__check_output(ctx, window->out_confidence + f, "out_confidence", 1, camera));
        gsf__warp_job job;
        job.carrier = carrier;
        job.window = window;
        job.frame = f;
        job.known = window->reference_index ? window->reference_index[f] : -1;
        gsf_get_camera_center(camera, job.center);
        job.near_count = gsf__carry_nearest(carrier, job.center, job.nearest, GSF__WARP_NEAREST);
        if (job.known < 0) GSF__TRY(gsf__carrier_draw(ctx, carrier, camera, job.nearest, job.near_count));
        gsf__parallel_for(ctx, (size_t)camera->height, gsf__warp_row, &job);
    }
    return GSF_OK;
}

static void gsf__warp_destroy(void* user, gsf_context* ctx) {
    gsf__warp_end(user, ctx);
    gsf_free(ctx, user);
}

GSF_API gsf_result gsf_splat_make_warp(gsf_context* ctx, gsf_restorer* out) {
    memset(out, 0, sizeof *out);
    out->user = gsf_alloc_zeroed(ctx, 1, sizeof(gsf__warp));
    if (!out->user) return GSF_ERROR_OUT_OF_MEMORY;
    out->struct_size = sizeof *out;
    out->name = "warp";
    out->query_fn = gsf__warp_query;
    out->begin_fn = gsf__warp_begin;
    out->restore_fn = gsf__warp_restore;
    out->end_fn = gsf__warp_end;
    out->destroy_fn = gsf__warp_destroy;
    return GSF_OK;
}

// ---- >>seen mask ---------------------------------------------------------------

typedef struct gsf__seen_job {
    const gsf_camera *camera, *seeing;
    size_t seeing_count;
    const float *depth, *alpha;        // rendered from `camera`
    const gsf__carry_reference* others; // cameras and depth maps of `seeing`
    const gsf_image* mask;
} gsf__seen_job;

// A pixel shows a surface if its alpha is at least 0.5. Another camera sees that surface if it is at most 5 % farther
// away than the depth rendered from that camera.
static void gsf__seen_row(void* arg, size_t row, int32_t worker) {
    (void)worker;
    const gsf__seen_job* job = (const gsf__seen_job*)arg;
    for (int32_t x = 0; x < job->camera->width; x++) {
        const size_t at = row * (size_t)job->camera->width + (size_t)x;
        uint8_t seen = 0;
        if (job->alpha[at] >= 0.5f) {
            double point[3], u, v, z;
            gsf__unproject(job->camera, x + 0.5, (double)row + 0.5, (double)job->depth[at], point);
            for (size_t k = 0; k < job->seeing_count && !seen; k++) {
                if (!gsf_project_point(job->seeing + k, point, &u, &v, &z)) continue;
                const float limit = gsf__nearest_depth(job->others + k, u, v);
                seen = limit > 0.0f && z <= 1.05 * (double)limit;
            }
        }
        char* out = (char*)job->mask->data + (int64_t)row * job->mask->stride_y + x * job->mask->stride_x;
        *(uint8_t*)out = seen;
    }
}

static gsf_result gsf__render_depth(gsf_context* ctx, gsf_rasterizer* rasterizer, const gsf_splats* splats,
                                    const gsf_camera* camera, float* depth, float* alpha) {
    gsf_render_output out;
    memset(&out, 0, sizeof out);
    out.depth = gsf_wrap_image(depth, GSF_F32, camera->width, camera->height, 1);
    if (alpha) out.alpha = gsf_wrap_image(alpha, GSF_F32, camera->width, camera->height, 1);
    return gsf_splat_render(ctx, rasterizer, splats, camera, NULL, &out);
}

GSF_API gsf_result gsf_splat_render_seen_mask(gsf_context* ctx, const gsf_splats* splats, const gsf_camera* camera,
                                              const gsf_camera* seeing, size_t seeing_count, const gsf_image* mask) {
    GSF__TRY(gsf_check_camera(ctx, camera));
    if (mask->dtype != GSF_U8 || mask->channels != 1 || mask->width != camera->width || mask->height != camera->height)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "seen mask: mask must be u8, 1 channel, of the camera's size");
    gsf_rasterizer* rasterizer = NULL;
    gsf__arena arena = {ctx, NULL, 0};
    const size_t pixels = (size_t)camera->width * (size_t)camera->height;
    float* planes = (float*)gsf__arena_alloc(&arena, pixels, 2 * sizeof(float));
    gsf__carry_reference* others = (gsf__carry_reference*)gsf__arena_alloc_zeroed(&arena, seeing_count, sizeof *others);
    gsf_result result = arena.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_splat_make_rasterizer(ctx, &rasterizer);
    if (result == GSF_OK) result = gsf__render_depth(ctx, rasterizer, splats, camera, planes, planes + pixels);
    for (size_t k = 0; k < seeing_count && result == GSF_OK; k++) {
        result = gsf_check_camera(ctx, seeing + k);
        if (result != GSF_OK) break;
        others[k].camera = seeing[k];
        others[k].depth = (float*)gsf__arena_alloc(&arena, (size_t)seeing[k].width * (size_t)seeing[k].height, sizeof(float));
        result = others[k].depth ? gsf__render_depth(ctx, rasterizer, splats, seeing + k, others[k].depth, NULL)
                                 : GSF_ERROR_OUT_OF_MEMORY;
    }
    if (result == GSF_OK) {
        gsf__seen_job job = {camera, seeing, seeing_count, planes, planes + pixels, others, mask};
        gsf__parallel_for(ctx, (size_t)camera->height, gsf__seen_row, &job);
    }
    gsf__arena_free(&arena);
    gsf_splat_destroy_rasterizer(ctx, rasterizer);
    return result;
}

// ---- >>fixer -------------------------------------------------------------------

typedef struct gsf__kept_frame { // a restored frame as it is stored until the round ends and in checkpoints
    gsf_camera camera;
    uint8_t* pixels;  // (H,W,3) colour, then (H,W) confidence 0..255
} gsf__kept_frame;

typedef struct gsf__kept_frames {
    gsf__kept_frame* frames;
    size_t count, capacity;
} gsf__kept_frames;

struct gsf_fixer {
    gsf_fix_desc desc;              // with defaults filled in
    const gsf_restorer* restorer;
    gsf_restorer explain;           // internal warp for the skip test and to be mixed in, if the restorer does not explain
    gsf_trainer* trainer;
    size_t view_count;
    gsf_camera* cameras;
    int32_t round, skipped;
    int restoring;                  // a round is in progress
    int planned;                    // the round has its path and buffers; not yet after loading a checkpoint
    int32_t window;                 // next window of this round
    int32_t frames;                 // frames per window, desc.window_frames
    gsf_camera* path;               // (windows, frames)
    int32_t* reference_index;
    int references_open;
    gsf_image *rendered, *depth, *alpha, *restored, *confidence; // frames of one window
    gsf_image *warped, *warped_confidence;                       // those of the internal warp, if they are mixed in
    gsf__kept_frames pending;       // frames of this round so far; those in training are trainer->restored
    gsf_restorer_info limits;
    // What carries photos into frames, for restorers that ask for it. The rest is empty unless one does.
    gsf__carrier carrier;
    gsf__carry_loan loan;           // of the current window
    double* points;                 // (point_count,3) means of the initial splats, which guide stereo
    size_t point_count;
};

static void gsf__drop_frames(gsf_context* ctx, gsf__kept_frames* list) {
    for (size_t i = 0; i < list->count; i++) gsf_free(ctx, list->frames[i].pixels);
    gsf_free(ctx, list->frames);
    memset(list, 0, sizeof *list);
}

enum { GSF__WINDOW_IMAGES = 7 }; // arrays of a window's frames

static gsf_image** gsf__window_images(gsf_fixer* f, int32_t i) {
    gsf_image** const arrays[GSF__WINDOW_IMAGES] = {&f->rendered,   &f->depth,  &f->alpha,            &f->restored,
                                                    &f->confidence, &f->warped, &f->warped_confidence};
    return arrays[i];
}

static void gsf__drop_window(gsf_context* ctx, gsf_fixer* f) {
    for (int32_t k = 0; k < GSF__WINDOW_IMAGES; k++) {
        gsf_image** images = gsf__window_images(f, k);
        for (int32_t i = 0; *images && i < f->frames; i++) gsf_destroy_image(ctx, *images + i);
        gsf_free(ctx, *images);
        *images = NULL;
    }
}

static void gsf__drop_path(gsf_context* ctx, gsf_fixer* f) {
    gsf_free(ctx, f->path);
    gsf_free(ctx, f->reference_index);
    f->path = NULL;
    f->reference_index = NULL;
}

static void gsf__close_references(gsf_context* ctx, gsf_fixer* f) {
    if (!f->references_open) return;
    gsf__carry_end_loan(ctx, &f->loan);
    gsf__carrier_close(ctx, &f->carrier);
    f->restorer->end_fn(f->restorer->user, ctx);
    if (f->explain.user) f->explain.end_fn(f->explain.user, ctx);
    f->references_open = 0;
}

GSF_API void gsf_splat_destroy_fixer(gsf_context* ctx, gsf_fixer* f) {
    if (!f) return;
    gsf__close_references(ctx, f);
    gsf__carrier_forget(ctx, &f->carrier);
    gsf_free(ctx, f->points);
    gsf_destroy_restorer(ctx, &f->explain);
    gsf__drop_window(ctx, f);
    gsf__drop_frames(ctx, &f->pending);
    gsf__drop_path(ctx, f);
    gsf_free(ctx, f->cameras);
    gsf_splat_destroy_trainer(ctx, f->trainer);
    gsf_free(ctx, f);
}

// The iteration just before the nearest densification, because renders are at their worst right after one.
static int32_t gsf__calm_iteration(const gsf_train_desc* d, int32_t iteration) {
    const int32_t interval = d->densify_interval > 0 ? d->densify_interval : 100;
    const int32_t calm = (iteration + interval / 2) / interval * interval - 1;
    return calm > 0 && calm < d->iterations ? calm : iteration;
}

static gsf_fix_desc gsf__fix_desc_defaults(const gsf_fix_desc* desc, size_t view_count, int has_restorer) {
    gsf_fix_desc d = *desc;
    if (d.train.iterations == 0) d.train.iterations = 30000;
    if (d.rounds == 0) d.rounds = 3;
    if (d.rounds < 0 || !has_restorer) d.rounds = 0;
    if (d.rounds == 0 && d.window_frames == 0) d.window_frames = 17; // otherwise chosen by gsf__ask_restorer
    if (d.first_round == 0) d.first_round = gsf__calm_iteration(&d.train, d.train.iterations / 3);
    if (d.last_round == 0) d.last_round = gsf__calm_iteration(&d.train, (int32_t)((int64_t)d.train.iterations * 5 / 6));
    if (d.last_round <= d.first_round) { // too short a run for two calm iterations
        const int32_t late = (int32_t)((int64_t)d.train.iterations * 5 / 6);
        d.last_round = desc->last_round == 0 && late > d.first_round ? late : d.first_round;
    }
    if (d.windows == 0) d.windows = view_count < 2 ? 2 : view_count > 64 ? 64 : (int32_t)view_count;
    d.lambda = gsf__or_zero(d.lambda, 1.0f);
    if (d.frame_scale == 0.0f) d.frame_scale = 1.0f;
    d.warp_weight = gsf__or_zero(d.warp_weight, 0.0f);
    d.auto_exposure = gsf__or_zero(d.auto_exposure, 1.0f);
    return d;
}

static gsf_fix_desc gsf__joining_desc(const gsf_fix_desc* copy) { // what joins copies that were trained by this desc
    gsf_fix_desc d = *copy;
    const int32_t iterations = d.train.iterations ? d.train.iterations : 30000;
    d.train.iterations = iterations < 8 ? 1 : iterations / 8;
    d.train.lr_means = 0.2f * gsf__or_zero(d.train.lr_means, 1.6e-4f);
    if (d.train.lr_means == 0.0f) d.train.lr_means = -1.0f;
    d.train.densify_until = -1;
    d.train.mcmc = 0;
    d.train.coarse_until = 0;
    d.train.dropout = 0.0f;
    if (d.rounds >= 0) d.rounds = 1;
    d.first_round = d.last_round = 1;
    d.skip_psnr = 0.0f;
    d.warp_weight = -1.0f;
    return d;
}

static gsf_result gsf__check_fix_desc(gsf_context* ctx, const gsf_fix_desc* d, const gsf_restorer* restorer) {
    if (d->first_round < 0 || d->first_round > d->train.iterations || d->last_round > d->train.iterations)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: invalid rounds %d..%d of %d iterations",
                        (int)d->first_round, (int)d->last_round, (int)d->train.iterations);
    if (d->windows < 1 || d->windows > 4096 || (d->window_frames && (d->window_frames < 3 || d->window_frames > 4096)))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: invalid %d windows of %d frames", (int)d->windows,
                        (int)d->window_frames);
    if (!(d->lambda >= 0.0f && d->lambda <= 1e6f) || !(d->skip_psnr >= 0.0f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: invalid lambda %g or skip_psnr %g", (double)d->lambda,
                        (double)d->skip_psnr);
    if (!(d->frame_scale > 0.0f && d->frame_scale <= 1.0f) || d->max_pixels < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: invalid frame_scale %g or max_pixels %d",
                        (double)d->frame_scale, (int)d->max_pixels);
    if (!(d->auto_exposure >= 0.0f && d->auto_exposure <= 1.0f) || !(d->warp_weight >= 0.0f && d->warp_weight <= 1e6f))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: invalid auto_exposure %g or warp_weight %g",
                        (double)d->auto_exposure, (double)d->warp_weight);
    if (d->copy_count && !d->copies) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: no copies");
    for (size_t k = 0; k < d->copy_count; k++) {
        const gsf_splats* splats = gsf_splat_get_trained(d->copies[k]->trainer);
        const gsf_splats* first = gsf_splat_get_trained(d->copies[0]->trainer);
        const int restorable = d->rounds < 1 || d->copies[k]->desc.rounds > 0;
        if (splats->sh_degree != first->sh_degree || d->copies[k]->restoring || !restorable)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                            "fix: copy %zu is within a round, or without a restorer or the SH degree of the first one", k);
    }
    if (d->path_count > 0x7fffffff || (d->path_count && !d->path))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: invalid path of %zu cameras", d->path_count);
    for (size_t i = 0; i < d->path_count; i++) GSF__TRY(gsf_check_camera(ctx, d->path + i));
    if (restorer && (restorer->struct_size < GSF__RESTORER_BYTES || !restorer->query_fn || !restorer->begin_fn ||
                     !restorer->restore_fn || !restorer->end_fn))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: the restorer's struct_size or a function is missing");
    return GSF_OK;
}

// Queries the restorer's limits and chooses the window length accordingly.
static gsf_result gsf__ask_restorer(gsf_context* ctx, gsf_fixer* f) {
    const gsf_camera* first = f->cameras;
    gsf_restorer_info* limits = &f->limits;
    memset(limits, 0, sizeof *limits);
    limits->struct_size = sizeof *limits;
    const int32_t usual = f->desc.window_frames > 0 ? f->desc.window_frames : 17;
    GSF__TRY(f->restorer->query_fn(f->restorer->user, ctx, usual, first->width, first->height, limits));
    if (limits->squash && (limits->width < 1 || limits->height < 1 || limits->width > 65536 || limits->height > 65536))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: the restorer has an invalid frame size of %d x %d",
                        (int)limits->width, (int)limits->height);
    const int32_t wanted = f->desc.window_frames == 0 && limits->frame_count > 0 ? limits->frame_count : usual;
    f->frames = gsf__legal_count(wanted, limits->frame_count_min > 0 ? limits->frame_count_min : 1, limits->frame_count_max,
                                 limits->frame_count_step);
    if (f->frames < 3 || f->frames > 4096)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "fix: the restorer needs unsupported windows of %d frames",
                        (int)f->frames);
    if (f->desc.window_frames && f->desc.window_frames != f->frames)
        gsf_log(ctx, GSF_LOG_WARNING, "windows of %d frames: the restorer takes %d instead", (int)f->desc.window_frames,
                (int)f->frames);
    f->desc.window_frames = f->frames;
    return GSF_OK;
}

// Camera with the full field of view of the path's camera, each axis scaled to the restorer's own frame size, or to a
// smaller one within max_pixels.
static gsf_camera gsf__squashed_camera(const gsf_fixer* f, const gsf_camera* camera) {
    const gsf_restorer_info* limits = &f->limits;
    const double pixels = (double)limits->width * limits->height, most = f->desc.max_pixels;
    const double scale = most > 0.0 && pixels > most ? sqrt(most / pixels) : 1.0;
    return gsf_resize_camera(camera, gsf__legal_side(limits->width * scale, limits->width_multiple, limits->width_max),
                             gsf__legal_side(limits->height * scale, limits->height_multiple, limits->height_max));
}

// Finds the frame size that keeps the aspect ratio of a view of width x height, and returns the scale of both axes. If
// the legal size is larger than the view wanted, the view is scaled up to fit into it.
static double gsf__square_size(const gsf_fixer* f, int32_t width, int32_t height, int32_t* frame_width,
                               int32_t* frame_height) {
    const gsf_restorer_info* limits = &f->limits;
    double scale = (double)f->desc.frame_scale;
    if (limits->width_max > 0 && width * scale > limits->width_max) scale = (double)limits->width_max / width;
    if (limits->height_max > 0 && height * scale > limits->height_max) scale = (double)limits->height_max / height;
    if (f->desc.max_pixels > 0 && width * scale * height * scale > f->desc.max_pixels)
        scale = sqrt((double)f->desc.max_pixels / ((double)width * height));
    *frame_width = gsf__legal_side(width * scale, limits->width_multiple, limits->width_max);
    *frame_height = gsf__legal_side(height * scale, limits->height_multiple, limits->height_max);
    if (limits->width_multiple > 1 || limits->height_multiple > 1)
        scale = fmax(scale, fmin((double)*frame_width / width, (double)*frame_height / height));
    return scale;
}

// The path's camera with both axes scaled alike. Each side gains or loses a little field of view to reach a legal size.
static gsf_camera gsf__square_camera(const gsf_fixer* f, const gsf_camera* camera) {
    gsf_camera out = *camera;
    const double scale = gsf__square_size(f, camera->width, camera->height, &out.width, &out.height);
    out.fx *= scale;
    out.fy *= scale;
    out.cx = camera->cx * scale + 0.5 * (out.width - camera->width * scale);
    out.cy = camera->cy * scale + 0.5 * (out.height - camera->height * scale);
    return out;
}

static gsf_camera gsf__frame_camera(const gsf_fixer* f, const gsf_camera* camera) {
    return f->limits.squash ? gsf__squashed_camera(f, camera) : gsf__square_camera(f, camera);
}

static void gsf__spread_path(gsf_fixer* f) { // samples desc.path evenly, for all frames of a round
    const size_t total = (size_t)f->desc.windows * (size_t)f->frames, given = f->desc.path_count;
    for (size_t i = 0; i < total; i++) {
        f->path[i] = f->cameras[0];
        memcpy(f->path[i].w2c, f->desc.path[(size_t)((2 * (uint64_t)i + 1) * given / (2 * total))].w2c, sizeof f->path[i].w2c);
        f->reference_index[i] = -1;
    }
}

static gsf_result gsf__sample_path(gsf_context* ctx, gsf_fixer* f) { // of round f->round
    const size_t total = (size_t)f->desc.windows * (size_t)f->frames;
    gsf__drop_path(ctx, f);
    f->path = (gsf_camera*)gsf_alloc(ctx, total, sizeof(gsf_camera));
    f->reference_index = (int32_t*)gsf_alloc(ctx, total, sizeof(int32_t));
    if (!f->path || !f->reference_index) return GSF_ERROR_OUT_OF_MEMORY;
    if (f->desc.path_count) {
        gsf__spread_path(f);
        return GSF_OK;
    }
    if (f->view_count < 2)
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "fix: one photo: repair takes a second one, or cameras given as a path");
    gsf_traj_path_desc desc;
    gsf_traj_path_info layout;
    memset(&desc, 0, sizeof desc);
    desc.kind = f->desc.trajectory;
    desc.window_length = f->frames;
    desc.window_count = f->desc.windows;
    desc.round = f->round;
    desc.seed = f->desc.train.seed;
    desc.points = f->desc.points;
    desc.point_count = f->desc.point_count;
    GSF__TRY(gsf_traj_query_path(ctx, f->view_count, &desc, &layout));
    GSF_ASSERT(layout.frame_count == total);
    void* scratch = gsf_alloc(ctx, layout.scratch_bytes, 1);
    if (!scratch) return GSF_ERROR_OUT_OF_MEMORY;
    const gsf_result result =
        gsf_traj_sample_path(ctx, f->cameras, f->view_count, &desc, scratch, f->path, f->reference_index);
    gsf_free(ctx, scratch);
    return result;
}

static int gsf__carries(const gsf_fixer* f) { return f->limits.needs_carried > 0 || f->explain.user != NULL; }

/* The union of the copies' splats. Where all have the same surface, the centres of n splats of opacity 1 - (1 - o)^(1/n) let as
   much light through as that of one of opacity o; a splat that one copy has and no other fades by about n. */
static gsf_result gsf__join_copies(gsf_context* ctx, const gsf_fix_desc* d, gsf_splats* out) {
    const gsf_splats* first = gsf_splat_get_trained(d->copies[0]->trainer);
    size_t count = 0;
    for (size_t k = 0; k < d->copy_count; k++) count += gsf_splat_get_trained(d->copies[k]->trainer)->count;
    GSF__TRY(gsf_splat_make(ctx, count, first->sh_degree, out));
    memcpy(out->background, first->background, sizeof out->background);
    memcpy(out->origin, first->origin, sizeof out->origin);
    out->antialiased = first->antialiased;
    size_t at = 0;
    for (size_t k = 0; k < d->copy_count; k++) {
        const gsf_splats* copy = gsf_splat_get_trained(d->copies[k]->trainer);
        gsf__column from[GSF__SPLAT_COLUMNS], to[GSF__SPLAT_COLUMNS];
        gsf__splat_columns(copy, from);
        gsf__splat_columns(out, to);
        for (int c = 0; c + 1 < GSF__SPLAT_COLUMNS; c++) // but the ids
            memcpy(to[c].data + at * to[c].row, from[c].data, copy->count * from[c].row);
        for (size_t i = at; i < at + copy->count; i++) {
            const double thickness = gsf__log1p_f64(gsf__exp_f64((double)out->opacity_logits[i])); // -log(1 - opacity)
            out->opacity_logits[i] = (float)gsf__log_f64(gsf__expm1_f64(thickness / (double)d->copy_count));
            for (size_t c = 0; c < 3; c++)
                out->means[3 * i + c] = (float)((double)out->means[3 * i + c] + (copy->origin[c] - out->origin[c]));
        }
        at += copy->count;
    }
    return GSF_OK;
}

static gsf_result gsf__keep_points(gsf_context* ctx, gsf_fixer* f, const gsf_splats* initial) {
    f->points = (double*)gsf_alloc(ctx, initial->count + 1, 3 * sizeof *f->points);
    if (!f->points) return GSF_ERROR_OUT_OF_MEMORY;
    f->point_count = initial->count;
    for (size_t i = 0; i < 3 * initial->count; i++) f->points[i] = initial->origin[i % 3] + (double)initial->means[i];
    return GSF_OK;
}

// Samples the path of every round once, so that an impossible path is reported before training starts.
static gsf_result gsf__check_paths(gsf_context* ctx, gsf_fixer* f) {
    gsf_result result = GSF_OK;
    for (f->round = 0; result == GSF_OK && f->round < f->desc.rounds; f->round++) result = gsf__sample_path(ctx, f);
    gsf__drop_path(ctx, f);
    f->round = 0;
    return result;
}

GSF_API gsf_result gsf_splat_make_fixer(gsf_context* ctx, const gsf_fix_desc* desc, const gsf_train_view* views,
                                        size_t view_count, const gsf_splats* initial, const gsf_restorer* restorer,
                                        gsf_fixer** out) {
    *out = NULL;
    gsf_fix_desc zero;
    memset(&zero, 0, sizeof zero);
    if (!desc) desc = &zero;
    GSF__CHECK_CANARIES(ctx, "fix", desc);
    GSF__TRY(gsf__check_train_canaries(ctx, &desc->train));
    gsf_fix_desc joining;
    if (desc->copy_count > 0) joining = gsf__joining_desc(desc), desc = &joining;
    const gsf_fix_desc resolved = gsf__fix_desc_defaults(desc, view_count, restorer != NULL);
    GSF__TRY(gsf__check_fix_desc(ctx, &resolved, restorer));
    gsf_fixer* f = (gsf_fixer*)gsf_alloc_zeroed(ctx, 1, sizeof *f);
    if (!f) return GSF_ERROR_OUT_OF_MEMORY;
    f->desc = resolved;
    f->restorer = restorer;
    gsf_splats joined;
    memset(&joined, 0, sizeof joined);
    gsf_result result = f->desc.copy_count ? gsf__join_copies(ctx, &f->desc, &joined) : GSF_OK;
    if (f->desc.copy_count) initial = &joined;
    if (result == GSF_OK) result = gsf_splat_make_trainer(ctx, &f->desc.train, views, view_count, initial, &f->trainer);
    if (result != GSF_OK) goto cleanup;
    f->cameras = (gsf_camera*)gsf_alloc(ctx, view_count, sizeof(gsf_camera));
    if (!f->cameras) result = GSF_ERROR_OUT_OF_MEMORY;
    for (; f->cameras && f->view_count < view_count; f->view_count++) f->cameras[f->view_count] = views[f->view_count].camera;
    if (result == GSF_OK && f->desc.rounds > 0) result = gsf__ask_restorer(ctx, f);
    if (desc->frame_scale == 0.0f && f->limits.frame_scale > 0.0f && f->limits.frame_scale <= 1.0f)
        f->desc.frame_scale = f->limits.frame_scale;
    if (desc->lambda == 0.0f) {
        const float few = (float)f->limits.lambda_views;
        if (f->limits.lambda > 0.0f && f->limits.lambda <= 1e6f) f->desc.lambda = f->limits.lambda;
        if (few > 0.0f && (float)view_count > few) f->desc.lambda *= few / (float)view_count;
    }
    if (desc->warp_weight == 0.0f && f->limits.warp_weight > 0.0f && f->limits.warp_weight <= 1e6f)
        f->desc.warp_weight = f->limits.warp_weight;
    if (f->limits.explains) f->desc.warp_weight = 0.0f;
    if (result == GSF_OK && f->desc.rounds > 0) result = gsf__check_paths(ctx, f);
    if (result == GSF_OK && f->desc.rounds > 0 && !f->limits.explains &&
        (f->desc.skip_psnr > 0.0f || f->desc.warp_weight > 0.0f))
        result = gsf_splat_make_warp(ctx, &f->explain);
    if (result == GSF_OK && gsf__carries(f)) result = gsf__keep_points(ctx, f, initial);
cleanup:
    gsf_splat_destroy(ctx, &joined);
    if (result != GSF_OK) gsf_splat_destroy_fixer(ctx, f);
    else *out = f;
    return result;
}

GSF_API gsf_fix_desc gsf_splat_get_fixer_desc(const gsf_fixer* fixer) {
    gsf_fix_desc desc = fixer->desc;
    desc.train = gsf_splat_get_trainer_desc(fixer->trainer);
    return desc;
}

GSF_API gsf_trainer* gsf_splat_get_trainer(const gsf_fixer* fixer) { return fixer->trainer; }

// Weight of the restored views; rises from 0 at the first round to desc.lambda at the last iteration.
static float gsf__restored_weight(const gsf_fixer* f) {
    return (float)gsf_traj_query_generative_weight(f->trainer->iteration, f->desc.first_round, f->desc.train.iterations,
                                                   (double)f->desc.lambda, 0);
}

// That weight in the coming step: the larger of 1 and desc.lambda in as many steps as make up for those without restored
// views, which cost nothing. Multiples of the golden ratio spread them evenly. (With twice that weight in half as many steps
// `warp` gains the same, but a perfect restorer much less.)
static float gsf__restored_step_weight(const gsf_fixer* f, float weight) {
    const float full = f->desc.lambda > 1.0f ? f->desc.lambda : 1.0f;
    const double turns = 0.6180339887498949 * (double)f->trainer->iteration;
    return turns - floor(turns) < (double)(weight / full) ? full : 0.0f;
}

static int gsf__round_is_due(const gsf_fixer* f) {
    const gsf_fix_desc* d = &f->desc;
    return f->round < d->rounds &&
           f->trainer->iteration >= gsf_traj_query_repair_round(d->first_round, d->last_round, d->rounds, f->round);
}

// Samples the path of this round, adapts its cameras to the restorer, and allocates the window's image arrays.
static gsf_result gsf__plan_round(gsf_context* ctx, gsf_fixer* f) {
    f->planned = 0;
    gsf__drop_window(ctx, f);
    GSF__TRY(gsf__sample_path(ctx, f));
    for (int32_t i = 0; i < f->desc.windows * f->frames; i++) f->path[i] = gsf__frame_camera(f, f->path + i);
    for (int32_t k = 0; k < GSF__WINDOW_IMAGES; k++) {
        gsf_image** images = gsf__window_images(f, k);
        *images = (gsf_image*)gsf_alloc_zeroed(ctx, (size_t)f->frames, sizeof(gsf_image));
        if (!*images) return GSF_ERROR_OUT_OF_MEMORY;
    }
    f->planned = 1;
    return GSF_OK;
}

// Blends the render into pixels of the reference photo according to how far their weight is below 1. Pixels with a
// weight below 0.5 also lose their depth, so that nothing is warped from there.
static gsf_result gsf__patch_reference(gsf_context* ctx, const float* weight, const gsf_image* render, gsf_reference* to) {
    gsf_image patched;
    const size_t pixels = (size_t)render->width * (size_t)render->height;
    GSF__TRY(gsf_make_image(ctx, GSF_F32, render->width, render->height, 3, &patched));
    float *out = (float*)patched.data, *depth = (float*)to->depth.data;
    const float *photo = (const float*)to->color.data, *shown = (const float*)render->data;
    for (size_t i = 0; i < pixels; i++) {
        const float w = weight[i] < 1.0f ? weight[i] : 1.0f;
        for (size_t k = 3 * i; k < 3 * i + 3; k++) out[k] = w * photo[k] + (1.0f - w) * shown[k];
        if (depth && w < 0.5f) depth[i] = 0.0f;
    }
    gsf_destroy_image(ctx, &to->color);
    to->color = patched;
    return GSF_OK;
}

// Makes the reference of view i: its photo and, if needs_depth, the splats' render and depth at its camera.
static gsf_result gsf__make_reference(gsf_context* ctx, gsf_fixer* f, size_t i, int needs_depth, gsf_reference* out) {
    const gsf_camera* camera = f->cameras + i;
    const gsf__photo* photo = &f->trainer->photos.photos[i];
    const gsf_image kept = gsf_wrap_image(photo->pixels, photo->target.u8 ? GSF_U8 : GSF_F32, camera->width, camera->height, 3);
    const float* weight = photo->target.weight;
    out->camera = *camera;
    GSF__TRY(gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &out->color));
    GSF__TRY(gsf_convert_image(ctx, &kept, &out->color));
    if (!needs_depth && !weight) return GSF_OK;
    gsf_render_output shown;
    memset(&shown, 0, sizeof shown);
    gsf_result result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 3, &shown.color);
    if (result == GSF_OK && needs_depth)
        result = gsf_make_image(ctx, GSF_F32, camera->width, camera->height, 1, &out->depth);
    if (result == GSF_OK) {
        shown.depth = out->depth;
        result = gsf_splat_render_trainer(ctx, f->trainer, camera, &shown);
    }
    if (result == GSF_OK && weight) result = gsf__patch_reference(ctx, weight, &shown.color, out);
    if (needs_depth) out->render = shown.color;
    else gsf_destroy_image(ctx, &shown.color);
    return result;
}

// Lets the carrier study the photos, unless it already has.
static gsf_result gsf__study_photos(gsf_context* ctx, gsf_fixer* f) {
    gsf__arena arena = {ctx, NULL, 0};
    if (f->carrier.studies) return GSF_OK;
    gsf_scene_view* views = (gsf_scene_view*)gsf__arena_alloc_zeroed(&arena, f->view_count, sizeof *views);
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < f->view_count && views && result == GSF_OK; i++) {
        const gsf__photo* photo = &f->trainer->photos.photos[i];
        const int32_t width = f->cameras[i].width, height = f->cameras[i].height;
        views[i].camera = f->cameras[i];
        views[i].image = gsf_wrap_image(photo->pixels, photo->target.u8 ? GSF_U8 : GSF_F32, width, height, 3);
        if (!photo->target.weight) continue;
        const gsf_image weight = gsf_wrap_image(photo->weight, GSF_F32, width, height, 1);
        uint8_t* bytes = (uint8_t*)gsf__arena_alloc(&arena, (size_t)width * (size_t)height, 1);
        views[i].weight = gsf_wrap_image(bytes, GSF_U8, width, height, 1);
        if (bytes) result = gsf_convert_image(ctx, &weight, &views[i].weight);
    }
    if (result == GSF_OK && arena.failed) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK)
        result = gsf__carrier_study(ctx, &f->carrier, views, (int32_t)f->view_count, f->points, f->point_count,
                                    f->desc.train.seed);
    gsf__arena_free(&arena);
    return result;
}

// Makes the references of all views, and begins the carrier and the restorer (and the internal warp) with them.
static gsf_result gsf__open_references(gsf_context* ctx, gsf_fixer* f) {
    if (f->references_open) return GSF_OK;
    gsf_reference* references = (gsf_reference*)gsf_alloc_zeroed(ctx, f->view_count, sizeof(gsf_reference));
    if (!references) return GSF_ERROR_OUT_OF_MEMORY;
    const int carries = gsf__carries(f), needs_depth = f->limits.needs_depth || carries;
    gsf_result result = carries ? gsf__study_photos(ctx, f) : GSF_OK;
    for (size_t i = 0; i < f->view_count && result == GSF_OK; i++)
        result = gsf__make_reference(ctx, f, i, needs_depth, references + i);
    if (result == GSF_OK && carries) result = gsf__carrier_take(ctx, &f->carrier, references, (int32_t)f->view_count);
    if (result == GSF_OK && carries) result = gsf__carrier_score(ctx, &f->carrier);
    if (result == GSF_OK)
        result = f->restorer->begin_fn(f->restorer->user, ctx, references, (int32_t)f->view_count);
    if (result == GSF_OK && f->explain.user) {
        result = f->explain.begin_fn(f->explain.user, ctx, references, (int32_t)f->view_count);
        if (result != GSF_OK) f->restorer->end_fn(f->restorer->user, ctx);
    }
    if (result == GSF_OK) f->references_open = 1;
    else gsf__carrier_close(ctx, &f->carrier);
    for (size_t i = 0; i < f->view_count; i++) {
        gsf_destroy_image(ctx, &references[i].color);
        gsf_destroy_image(ctx, &references[i].render);
        gsf_destroy_image(ctx, &references[i].depth);
    }
    gsf_free(ctx, references);
    return result;
}

// PSNR in dB of the window's render against what the references explain (out_color), over the explained pixels,
// weighted by out_confidence. 0 if less than half of the pixels are explained.
static double gsf__window_agreement(const gsf_restore_window* window) {
    double error = 0.0, weight = 0.0, pixels = 0.0, explained = 0.0;
    for (int32_t i = 0; i < window->frame_count; i++)
        for (int64_t y = 0; y < window->color[i].height; y++)
            for (int64_t x = 0; x < window->color[i].width; x++) {
                const double w = (double)gsf__get_pixel(window->out_confidence + i, x, y, 0);
                pixels += 1.0;
                explained += w > 0.0;
                weight += w;
                for (int c = 0; c < 3 && w > 0.0; c++) {
                    const double d = (double)gsf__get_pixel(window->color + i, x, y, c) -
                                     (double)gsf__get_pixel(window->out_color + i, x, y, c);
                    error += w * d * d / 3.0;
                }
            }
    if (explained < 0.5 * pixels) return 0.0;
    return error > 0.0 ? -10.0 * log10(error / weight) : (double)INFINITY;
}

// Mixes the frames of the internal warp into those of the restorer: two that err in different ways err less together.
static void gsf__mix_warped(const gsf_fixer* f, const gsf_restore_window* window) {
    const float weight = f->desc.warp_weight;
    for (int32_t i = 0; i < window->frame_count; i++) {
        gsf_image *color = window->out_color + i, *confidence = window->out_confidence + i;
        for (int64_t y = 0; y < color->height; y++)
            for (int64_t x = 0; x < color->width; x++) {
                const float own = gsf__get_pixel(confidence, x, y, 0);
                const float warped = weight * gsf__get_pixel(f->warped_confidence + i, x, y, 0), sum = own + warped;
                gsf__put_pixel(confidence, x, y, 0, sum / (1.0f + weight));
                for (int c = 0; c < 3 && warped > 0.0f; c++) {
                    const float value = own * gsf__get_pixel(color, x, y, c) + warped * gsf__get_pixel(f->warped + i, x, y, c);
                    gsf__put_pixel(color, x, y, c, value / sum);
                }
            }
    }
}

// Restores the window, or skips it (*skip = 1) if its render already agrees with the photos.
static gsf_result gsf__restore_or_skip(gsf_context* ctx, const gsf_fixer* f, const gsf_restore_window* window, int* skip) {
    const int mixed = f->desc.warp_weight > 0.0f;
    *skip = 0;
    if (f->desc.copy_count > 0)
        return gsf_splat_restore_views(ctx, f->desc.copies, f->desc.copy_count, window->cameras, (size_t)window->frame_count,
                                       window->out_color, window->out_confidence);
    if (f->desc.skip_psnr > 0.0f || mixed) {
        const gsf_restorer* explain = f->limits.explains ? f->restorer : &f->explain;
        gsf_restore_window shared = *window; // the internal warp uses the loop's carrier, whatever the restorer asks for
        if (gsf__carries(f)) shared.carry_fn = gsf__carry_for_window;
        if (mixed) shared.out_color = f->warped, shared.out_confidence = f->warped_confidence;
        GSF__TRY(explain->restore_fn(explain->user, ctx, &shared));
        *skip = f->desc.skip_psnr > 0.0f && gsf__window_agreement(&shared) >= (double)f->desc.skip_psnr;
        if (*skip || f->limits.explains) return GSF_OK;
    }
    GSF__TRY(f->restorer->restore_fn(f->restorer->user, ctx, window));
    if (mixed) gsf__mix_warped(f, window);
    return GSF_OK;
}

// Appends a frame. pixels: its bytes, NULL = to be filled in by the caller.
static gsf_result gsf__add_frame(gsf_context* ctx, gsf__kept_frames* list, const gsf_camera* camera, const void* pixels) {
    const size_t bytes = 4 * (size_t)camera->width * (size_t)camera->height;
    GSF__TRY(gsf__reserve(ctx, (void**)&list->frames, &list->capacity, list->count, list->count + 1, sizeof *list->frames));
    gsf__kept_frame* frame = list->frames + list->count;
    frame->camera = *camera;
    frame->pixels = (uint8_t*)gsf_alloc(ctx, bytes, 1);
    if (!frame->pixels) return GSF_ERROR_OUT_OF_MEMORY;
    if (pixels) memcpy(frame->pixels, pixels, bytes);
    list->count++;
    return GSF_OK;
}

static gsf_result gsf__keep_frame(gsf_context* ctx, gsf_fixer* f, const gsf_camera* camera, const gsf_image* color,
                                  const gsf_image* confidence) {
    GSF__TRY(gsf__add_frame(ctx, &f->pending, camera, NULL));
    uint8_t* pixels = f->pending.frames[f->pending.count - 1].pixels;
    const gsf_image rgb = gsf_wrap_image(pixels, GSF_U8, camera->width, camera->height, 3);
    const gsf_image weight = gsf_wrap_image(pixels + 3 * (size_t)camera->width * (size_t)camera->height, GSF_U8,
                                            camera->width, camera->height, 1);
    GSF__TRY(gsf_convert_image(ctx, color, &rgb));
    return gsf_convert_image(ctx, confidence, &weight);
}

// Converts kept frames to a photo set for gsf__restored_take.
static gsf_result gsf__frames_to_photos(gsf_context* ctx, gsf_fixer* f, const gsf__kept_frames* list,
                                        gsf__photo_set* out) {
    gsf_train_view* views = (gsf_train_view*)gsf_alloc_zeroed(ctx, list->count + 1, sizeof(gsf_train_view));
    if (!views) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < list->count; i++) {
        const gsf_camera* camera = &list->frames[i].camera;
        uint8_t* pixels = list->frames[i].pixels;
        const size_t count = (size_t)camera->width * (size_t)camera->height;
        views[i].camera = *camera;
        views[i].image = gsf_wrap_image(pixels, GSF_U8, camera->width, camera->height, 3);
        views[i].weight = gsf_wrap_image(pixels + 3 * count, GSF_U8, camera->width, camera->height, 1);
    }
    const gsf_result result = gsf__restored_make(ctx, f->trainer, views, list->count, out);
    gsf_free(ctx, views);
    return result;
}

// Zeroes the confidence outside the field of view of the path's cameras, which have the photos' intrinsics.
static void gsf__distrust_margin(const gsf_fixer* f, gsf_image* confidence) {
    const gsf_camera* view = f->cameras; // all cameras of the path have its size
    int32_t width, height;
    if (f->limits.squash) return;
    const double scale = gsf__square_size(f, view->width, view->height, &width, &height);
    const double reach_x = 0.5 * view->width * scale, reach_y = 0.5 * view->height * scale;
    for (int32_t y = 0; y < height; y++)
        for (int32_t x = 0; x < width; x++)
            if (fabs(x + 0.5 - 0.5 * width) > reach_x || fabs(y + 0.5 - 0.5 * height) > reach_y)
                ((float*)confidence->data)[(size_t)y * (size_t)width + (size_t)x] = 0.0f;
}

// Renders the splats for all frames of a window, and fits its images to the frame sizes.
static gsf_result gsf__render_window(gsf_context* ctx, gsf_fixer* f, const gsf_camera* cameras) {
    for (int32_t i = 0; i < f->frames; i++) {
        const gsf_camera* camera = cameras + i;
        GSF__TRY(gsf__check_cancel(ctx));
        GSF__TRY(gsf__fit_image(ctx, f->rendered + i, camera, 3));
        GSF__TRY(gsf__fit_image(ctx, f->depth + i, camera, 1));
        if (f->limits.needs_alpha) GSF__TRY(gsf__fit_image(ctx, f->alpha + i, camera, 1));
        GSF__TRY(gsf__fit_image(ctx, f->restored + i, camera, 3));
        GSF__TRY(gsf__fit_image(ctx, f->confidence + i, camera, 1));
        if (f->desc.warp_weight > 0.0f) {
            GSF__TRY(gsf__fit_image(ctx, f->warped + i, camera, 3));
            GSF__TRY(gsf__fit_image(ctx, f->warped_confidence + i, camera, 1));
        }
        gsf_render_output out;
        memset(&out, 0, sizeof out);
        out.color = f->rendered[i];
        out.depth = f->depth[i];
        out.alpha = f->alpha[i];
        GSF__TRY(gsf_splat_render_trainer(ctx, f->trainer, camera, &out));
    }
    return GSF_OK;
}

// Keeps all frames of the restored window or, if one fails, none of them.
static gsf_result gsf__keep_window(gsf_context* ctx, gsf_fixer* f, const gsf_restore_window* window) {
    const size_t before = f->pending.count;
    for (int32_t i = 0; i < f->frames; i++) {
        gsf__distrust_margin(f, f->confidence + i);
        if (window->reference_index[i] >= 0) continue; // a photo, which is trained on anyway
        const gsf_result result = gsf__keep_frame(ctx, f, window->cameras + i, f->restored + i, f->confidence + i);
        if (result == GSF_OK) continue;
        while (f->pending.count > before) gsf_free(ctx, f->pending.frames[--f->pending.count].pixels);
        return result;
    }
    return GSF_OK;
}

// Lends the carrier to a window of frames at these cameras, with this depth.
static void gsf__lend_carrier(gsf_fixer* f, gsf_restore_window* window, const gsf_image* depth) {
    f->loan.carrier = &f->carrier;
    f->loan.frame_count = window->frame_count;
    f->loan.slot_count = f->limits.needs_carried < GSF__CARRY_SLOTS ? f->limits.needs_carried : GSF__CARRY_SLOTS;
    f->loan.cameras = window->cameras;
    f->loan.depth = depth;
    window->carry_fn = f->limits.needs_carried > 0 ? gsf__carry_for_window : NULL;
    window->carry_user = &f->loan;
}

static gsf_result gsf__restore_window(gsf_context* ctx, gsf_fixer* f, gsf_fix_stats* stats) {
    const size_t begin = (size_t)f->window * (size_t)f->frames;
    int skip;
    if (!f->desc.copy_count) GSF__TRY(gsf__open_references(ctx, f));
    gsf_restore_window window;
    memset(&window, 0, sizeof window);
    window.struct_size = sizeof window;
    window.frame_count = f->frames;
    window.cameras = f->path + begin;
    window.reference_index = f->reference_index + begin;
    window.seed = gsf_draw_bits(f->desc.train.seed, 0x77696e64u, (uint64_t)f->round * 4096u + (uint64_t)f->window);
    window.clip = f->round * f->desc.windows + f->window;
    GSF__TRY(gsf__render_window(ctx, f, window.cameras));
    window.color = f->rendered;
    window.depth = f->limits.needs_depth ? f->depth : NULL;
    window.alpha = f->limits.needs_alpha ? f->alpha : NULL;
    window.out_color = f->restored;
    window.out_confidence = f->confidence;
    gsf__lend_carrier(f, &window, f->depth);
    GSF__TRY(gsf__restore_or_skip(ctx, f, &window, &skip));
    if (!skip) GSF__TRY(gsf__keep_window(ctx, f, &window));
    f->skipped += skip;
    stats->frame_count = f->frames;
    stats->cameras = window.cameras;
    stats->rendered = f->rendered;
    stats->restored = skip ? NULL : f->restored;
    stats->confidence = skip ? NULL : f->confidence;
    stats->reference_index = window.reference_index;
    f->window++;
    return GSF_OK;
}

static gsf_result gsf__finish_round(gsf_context* ctx, gsf_fixer* f) {
    gsf__photo_set photos;
    gsf__close_references(ctx, f);
    gsf__drop_window(ctx, f);
    GSF__TRY(gsf__frames_to_photos(ctx, f, &f->pending, &photos));
    gsf__restored_take(ctx, f->trainer, &photos);
    gsf__drop_frames(ctx, &f->pending);
    f->restoring = 0;
    f->round++;
    return GSF_OK;
}

static gsf_result gsf__render_views(gsf_context* ctx, const gsf_fixer* f, const gsf_camera* cameras, size_t count,
                                    gsf_image* images) { // (3, count): colours, depths, opacities
    for (size_t i = 0; i < count; i++) {
        gsf_render_output out;
        memset(&out, 0, sizeof out);
        GSF__TRY(gsf__check_cancel(ctx));
        GSF__TRY(gsf_check_camera(ctx, cameras + i));
        for (size_t k = 0; k < 3; k++)
            GSF__TRY(gsf_make_image(ctx, GSF_F32, cameras[i].width, cameras[i].height, k ? 1 : 3, &images[k * count + i]));
        out.color = images[i];
        out.depth = images[count + i];
        out.alpha = images[2 * count + i];
        GSF__TRY(gsf_splat_render_trainer(ctx, f->trainer, cameras + i, &out));
    }
    return GSF_OK;
}

// What becomes of a frame that was restored from carried photos: it is exposed as the photos' camera would have. Alone, without
// copies that tell where the restorer errs, and with few photos it stays the render as far as light passes the splats, since
// what carries photos there is the depth of the few that stop light, often a wrong one. Measured in bench/TRIED.md
static void gsf__finish_view(gsf_fixer* f, const gsf_camera* camera, const gsf_image* render, const gsf_image* alpha, int alone,
                             gsf_image* color) {
    const int exposed = f->desc.auto_exposure > 0.0f && f->carrier.automatic > 0.0;
    const int by_opacity = alone && f->view_count < GSF__WARP_FEW;
    float factor = 1.0f;
    if (!exposed && !by_opacity) return;
    if (exposed)
        factor = gsf__carry_meter_frame(&f->carrier, camera, render, alpha, f->trainer->desc.render.background,
                                        (double)f->desc.auto_exposure);
    for (int64_t y = 0; y < color->height; y++)
        for (int64_t x = 0; x < color->width; x++) {
            const float share = by_opacity ? gsf__get_pixel(alpha, x, y, 0) : 1.0f;
            for (int c = 0; c < 3; c++) {
                const float restored = gsf__get_pixel(color, x, y, c);
                const float value = factor * (share * restored + (1.0f - share) * gsf__get_pixel(render, x, y, c));
                gsf__put_pixel(color, x, y, c, value < 1.0f ? value : 1.0f);
            }
        }
}

// images: as of gsf__render_views.
static gsf_result gsf__restore_views_of(gsf_context* ctx, gsf_fixer* f, int alone, const gsf_camera* cameras, size_t count,
                                        const int32_t* known, gsf_image* images, gsf_image* color, gsf_image* confidence) {
    gsf_restore_window window;
    GSF__TRY(gsf__render_views(ctx, f, cameras, count, images));
    GSF__TRY(gsf__open_references(ctx, f));
    memset(&window, 0, sizeof window);
    window.struct_size = sizeof window;
    window.frame_count = (int32_t)count;
    window.cameras = cameras;
    window.reference_index = known;
    window.seed = f->desc.train.seed;
    window.clip = f->desc.rounds * f->desc.windows;
    window.color = images;
    window.depth = f->limits.needs_depth ? images + count : NULL;
    window.alpha = f->limits.needs_alpha ? images + 2 * count : NULL;
    window.out_color = color;
    window.out_confidence = confidence;
    gsf__lend_carrier(f, &window, images + count);
    GSF__TRY(gsf_restore_clip(ctx, f->restorer, &window));
    for (size_t i = 0; i < count && f->limits.needs_carried > 0; i++)
        gsf__finish_view(f, cameras + i, images + i, images + 2 * count + i, alone, color + i);
    return GSF_OK;
}

/* What several copies make of one view. A restorer errs where it paints what nothing confirms, by the wrong depth for example,
   and copies have other depths there: it makes them differ more than they did. So, with the variances v over the copies, each
   the mean over cells of 16 x 16 pixels,
       color = s mean(restored) + (1 - s) mean(renders)    s = min(1, (v(renders) + e) / (v(restored) + e)) */
enum { GSF__COPIES_CELL = 16 };
static const float gsf__copies_least = 1e-4f; // e: differences of 0.01 do not count

typedef struct gsf__copies_pixel { float render[3], restored[3], spread[2], confidence; } gsf__copies_pixel;

static void gsf__count_copy(float value, float number, float* mean, float* spread) { // spread: sum of squares about the mean
    const float from_old = value - *mean;
    *mean += from_old / number;
    *spread += from_old * (value - *mean);
}

static void gsf__add_copy(gsf__copies_pixel* p, const gsf_image* render, const gsf_image* restored, const gsf_image* confidence,
                          size_t number) { // from 1
    for (int64_t y = 0; y < render->height; y++)
        for (int64_t x = 0; x < render->width; x++, p++) {
            float ignored = 0.0f;
            for (int c = 0; c < 3; c++) {
                gsf__count_copy(gsf__get_pixel(render, x, y, c), (float)number, &p->render[c], &p->spread[0]);
                gsf__count_copy(gsf__get_pixel(restored, x, y, c), (float)number, &p->restored[c], &p->spread[1]);
            }
            gsf__count_copy(gsf__get_pixel(confidence, x, y, 0), (float)number, &p->confidence, &ignored);
        }
}

static gsf_result gsf__mix_copies(gsf_context* ctx, const gsf__copies_pixel* pixels, size_t copies, gsf_image* color,
                                  gsf_image* confidence) {
    const int64_t width = color->width, height = color->height;
    const int64_t across = (width + GSF__COPIES_CELL - 1) / GSF__COPIES_CELL;
    const int64_t down = (height + GSF__COPIES_CELL - 1) / GSF__COPIES_CELL;
    const float scale = 1.0f / (3.0f * (float)(copies - 1));
    gsf_image spread, cells, shares, share;
    memset(&spread, 0, sizeof spread);
    cells = shares = share = spread;
    gsf_result result = gsf_make_image(ctx, GSF_F32, width, height, 2, &spread);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, across, down, 2, &cells);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, across, down, 1, &shares);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, width, height, 1, &share);
    for (int64_t i = 0; result == GSF_OK && i < 2 * width * height; i++)
        ((float*)spread.data)[i] = pixels[i / 2].spread[i % 2];
    if (result == GSF_OK) result = gsf_resize_image(ctx, &spread, GSF_RESIZE_PIL_BILINEAR, &cells);
    for (int64_t i = 0; result == GSF_OK && i < across * down; i++) {
        const float* v = (const float*)cells.data + 2 * i;
        const float kept = (v[0] * scale + gsf__copies_least) / (v[1] * scale + gsf__copies_least);
        ((float*)shares.data)[i] = kept < 1.0f ? kept : 1.0f;
    }
    if (result == GSF_OK) result = gsf_resize_image(ctx, &shares, GSF_RESIZE_PIL_BILINEAR, &share);
    for (int64_t i = 0; result == GSF_OK && i < width * height; i++) {
        const gsf__copies_pixel* p = pixels + i;
        const float s = ((const float*)share.data)[i];
        for (int c = 0; c < 3; c++)
            gsf__put_pixel(color, i % width, i / width, c, s * p->restored[c] + (1.0f - s) * p->render[c]);
        gsf__put_pixel(confidence, i % width, i / width, 0, p->confidence);
    }
    gsf_destroy_image(ctx, &spread);
    gsf_destroy_image(ctx, &cells);
    gsf_destroy_image(ctx, &shares);
    gsf_destroy_image(ctx, &share);
    return result;
}

GSF_API gsf_result gsf_splat_restore_views(gsf_context* ctx, gsf_fixer* const* fixers, size_t fixer_count,
                                           const gsf_camera* cameras, size_t count, gsf_image* color, gsf_image* confidence) {
    gsf_result result = fixer_count < 1 || count < 1 || count > 4096 ? GSF_ERROR_INVALID_ARGUMENT : GSF_OK;
    for (size_t k = 0; k < fixer_count && result == GSF_OK; k++)
        if (fixers[k]->desc.rounds < 1 || fixers[k]->restoring) result = GSF_ERROR_INVALID_ARGUMENT;
    if (result != GSF_OK)
        return gsf_fail(ctx, result, "restore: %zu views by %zu fixers, or one without a restorer or within a round", count,
                        fixer_count);
    for (size_t i = 0; i < count && fixer_count > 1; i++)
        if (cameras[i].width != color->width || cameras[i].height != color->height)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "restore: view %zu has another size than the first image", i);
    const size_t size = (size_t)color->width * (size_t)color->height;
    gsf_image* images = (gsf_image*)gsf_alloc_zeroed(ctx, count, 3 * sizeof *images);
    int32_t* known = (int32_t*)gsf_alloc(ctx, count, sizeof *known);
    gsf__copies_pixel* pixels = NULL;
    if (fixer_count > 1 && size <= SIZE_MAX / count) // an overflow counts as out of memory
        pixels = (gsf__copies_pixel*)gsf_alloc_zeroed(ctx, size * count, sizeof *pixels);
    if (!images || !known || (fixer_count > 1 && !pixels)) result = GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; known && i < count; i++) known[i] = -1;
    for (size_t k = 0; k < fixer_count && pixels; k++) gsf__close_references(ctx, fixers[k]);
    for (size_t k = 0; k < fixer_count && result == GSF_OK; k++) {
        result = gsf__restore_views_of(ctx, fixers[k], fixer_count == 1, cameras, count, known, images, color, confidence);
        for (size_t i = 0; i < count && pixels && result == GSF_OK; i++)
            gsf__add_copy(pixels + i * size, images + i, color + i, confidence + i, k + 1);
        for (size_t i = 0; i < 3 * count; i++) gsf_destroy_image(ctx, &images[i]);
        if (pixels) gsf__close_references(ctx, fixers[k]); // the next copy may have the same restorer
    }
    for (size_t i = 0; i < count && pixels && result == GSF_OK; i++)
        result = gsf__mix_copies(ctx, pixels + i * size, fixer_count, color + i, confidence + i);
    gsf_free(ctx, images);
    gsf_free(ctx, known);
    gsf_free(ctx, pixels);
    return result;
}

GSF_API gsf_result gsf_splat_step_fixer(gsf_context* ctx, gsf_fixer* f, gsf_fix_stats* stats) {
    gsf_fix_stats ignored;
    if (!stats) stats = &ignored;
    memset(stats, 0, sizeof *stats);
    stats->rounds = f->desc.rounds;
    stats->round = f->round + 1;
    stats->windows = f->desc.windows;
    stats->window = f->window + 1;
    GSF__TRY(gsf__check_cancel(ctx));
    if (f->restoring && f->window >= f->desc.windows) GSF__TRY(gsf__finish_round(ctx, f));
    if (f->restoring) {
        stats->stage = GSF_FIX_RESTORE;
        if (!f->planned) GSF__TRY(gsf__plan_round(ctx, f));
        GSF__TRY(gsf__restore_window(ctx, f, stats));
    } else if (gsf__round_is_due(f)) {
        stats->stage = GSF_FIX_PLAN;
        GSF__TRY(gsf__plan_round(ctx, f));
        f->restoring = 1;
        f->window = 0;
    } else if (f->trainer->iteration >= f->desc.train.iterations) {
        stats->stage = GSF_FIX_DONE;
    } else {
        stats->stage = GSF_FIX_TRAIN;
        gsf__close_references(ctx, f); // which gsf_splat_restore_views has left open
        stats->lambda = f->trainer->restored.count ? gsf__restored_weight(f) : 0.0f;
        gsf_splat_set_restored_weight(f->trainer, gsf__restored_step_weight(f, stats->lambda));
        GSF__TRY(gsf_splat_step_trainer(ctx, f->trainer, &stats->train));
    }
    stats->skipped = f->skipped;
    return GSF_OK;
}

/* A checkpoint holds the trainer's chunks and, little-endian:
       "FIXR"           7 x i32: version, iteration (of the trainer), round, restoring, window, windows, skipped
       "FIXA", "FIXP"   frames in training and those of the current round: u64 count, then per frame 20 x f64 (w2c, fx,
                        fy, cx, cy), 2 x i32 (width, height), H*W*3 bytes of colour, H*W bytes of confidence */
enum { GSF__FRAME_HEAD = 20 * 8 + 2 * 4 };

static size_t gsf__frame_bytes(const gsf_camera* camera) {
    return GSF__FRAME_HEAD + 4 * (size_t)camera->width * (size_t)camera->height;
}

static size_t gsf__open_frames(gsf_context* ctx, gsf_buffer* chunks, const char* tag, size_t count) {
    char head[8];
    const size_t opened = gsf__open_chunk(ctx, chunks, tag); // written in place: frames make up most of a checkpoint
    gsf__store_le(head, count, 8);
    gsf_append_bytes(ctx, chunks, head, sizeof head);
    return opened;
}

static void gsf__save_frame(gsf_context* ctx, gsf_buffer* chunks, const gsf_camera* camera, const uint8_t* pixels) {
    char head[GSF__FRAME_HEAD];
    double numbers[20];
    memcpy(numbers, camera->w2c, sizeof camera->w2c);
    numbers[16] = camera->fx;
    numbers[17] = camera->fy;
    numbers[18] = camera->cx;
    numbers[19] = camera->cy;
    for (int k = 0; k < 20; k++) gsf__store_f64(head + 8 * k, numbers[k]);
    gsf__store_le(head + 160, (uint32_t)camera->width, 4);
    gsf__store_le(head + 164, (uint32_t)camera->height, 4);
    gsf_append_bytes(ctx, chunks, head, sizeof head);
    gsf_append_bytes(ctx, chunks, (const char*)pixels, 4 * (size_t)camera->width * (size_t)camera->height);
}

static void gsf__save_pending(gsf_context* ctx, gsf_buffer* chunks, const gsf__kept_frames* list) {
    const size_t opened = gsf__open_frames(ctx, chunks, "FIXP", list->count);
    for (size_t i = 0; i < list->count; i++) gsf__save_frame(ctx, chunks, &list->frames[i].camera, list->frames[i].pixels);
    gsf__close_chunk(ctx, chunks, opened);
}

// Frames in training were made from bytes, so that converting them back is lossless.
static void gsf__save_restored(gsf_context* ctx, gsf_buffer* chunks, const gsf__photo_set* set) {
    uint8_t* pixels = (uint8_t*)gsf_alloc(ctx, (size_t)set->max_width * (size_t)set->max_height + 1, 4);
    const size_t opened = gsf__open_frames(ctx, chunks, "FIXA", set->count);
    for (size_t i = 0; i < set->count && pixels; i++) {
        const gsf__photo* photo = set->photos + i;
        const int32_t width = photo->camera.width, height = photo->camera.height;
        const size_t count = (size_t)width * (size_t)height;
        const gsf_image color = gsf_wrap_image(photo->pixels, photo->target.u8 ? GSF_U8 : GSF_F32, width, height, 3);
        const gsf_image weight = gsf_wrap_image(photo->weight, GSF_F32, width, height, 1);
        const gsf_image bytes = gsf_wrap_image(pixels, GSF_U8, width, height, 3);
        const gsf_image confidence = gsf_wrap_image(pixels + 3 * count, GSF_U8, width, height, 1);
        memset(confidence.data, 255, count);
        if (gsf_convert_image(ctx, &color, &bytes) != GSF_OK ||
            (photo->weight && gsf_convert_image(ctx, &weight, &confidence) != GSF_OK))
            chunks->failed = 1;
        gsf__save_frame(ctx, chunks, &photo->camera, pixels);
    }
    if (!pixels) chunks->failed = 1;
    gsf__close_chunk(ctx, chunks, opened);
    gsf_free(ctx, pixels);
}

// Reads a frame from the `left` bytes at p; returns its size there, 0 if it is malformed.
static size_t gsf__parse_frame(gsf_context* ctx, const char* p, size_t left, gsf_camera* camera) {
    double numbers[20];
    if (left < GSF__FRAME_HEAD) return 0;
    memset(camera, 0, sizeof *camera);
    for (size_t k = 0; k < 20; k++) numbers[k] = gsf__load_f64(p + 8 * k);
    memcpy(camera->w2c, numbers, sizeof camera->w2c);
    camera->fx = numbers[16];
    camera->fy = numbers[17];
    camera->cx = numbers[18];
    camera->cy = numbers[19];
    camera->width = (int32_t)gsf__load_le(p + 160, 4);
    camera->height = (int32_t)gsf__load_le(p + 164, 4);
    if (gsf_check_camera(ctx, camera) != GSF_OK || camera->width > 65536 || camera->height > 65536) return 0;
    const size_t bytes = gsf__frame_bytes(camera);
    return bytes <= left ? bytes : 0;
}

static gsf_result gsf__load_frames(gsf_context* ctx, const char* name, const void* data, size_t size, const char* tag,
                                   gsf__kept_frames* out) {
    gsf_chunk chunk;
    memset(out, 0, sizeof *out);
    if (!gsf_find_chunk(data, size, tag, &chunk) || chunk.size < 8)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no %s chunk", name, tag);
    const char *p = (const char*)chunk.data + 8, *end = p + chunk.size - 8;
    const uint64_t count = gsf__load_le(chunk.data, 8);
    gsf_result result = GSF_OK;
    for (uint64_t i = 0; result == GSF_OK && i < count; i++) {
        gsf_camera camera;
        const size_t bytes = gsf__parse_frame(ctx, p, (size_t)(end - p), &camera);
        if (!bytes)
            result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: chunk %s, frame %llu is malformed", name, tag, (unsigned long long)i);
        else result = gsf__add_frame(ctx, out, &camera, p + GSF__FRAME_HEAD);
        p += bytes;
    }
    if (result != GSF_OK) gsf__drop_frames(ctx, out);
    return result;
}

GSF_API void gsf_splat_format_fixer(gsf_context* ctx, const gsf_fixer* f, gsf_buffer* chunks) {
    size_t bytes = 256;
    for (size_t i = 0; i < f->pending.count; i++) bytes += gsf__frame_bytes(&f->pending.frames[i].camera);
    for (size_t i = 0; i < f->trainer->restored.count; i++) bytes += gsf__frame_bytes(&f->trainer->restored.photos[i].camera);
    gsf__trainer_reserve_chunks(ctx, f->trainer, bytes, chunks);
    gsf_splat_format_trainer(ctx, f->trainer, chunks);
    const int32_t numbers[7] = {1, f->trainer->iteration, f->round, f->restoring, f->window, f->desc.windows, f->skipped};
    char body[28];
    for (int k = 0; k < 7; k++) gsf__store_le(body + 4 * k, (uint32_t)numbers[k], 4);
    gsf_append_chunk(ctx, chunks, "FIXR", body, sizeof body);
    gsf__save_restored(ctx, chunks, &f->trainer->restored);
    gsf__save_pending(ctx, chunks, &f->pending);
}

GSF_API gsf_result gsf_splat_parse_fixer(gsf_context* ctx, gsf_fixer* f, const char* name, const void* data,
                                         size_t size) {
    gsf_chunk chunk;
    int32_t numbers[7];
    GSF__TRY(gsf_check_chunks(ctx, name, data, size));
    if (!gsf_find_chunk(data, size, "FIXR", &chunk) || chunk.size != 28)
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: no FIXR chunk: not a checkpoint of the repair loop", name);
    for (int k = 0; k < 7; k++) numbers[k] = (int32_t)gsf__load_le((const char*)chunk.data + 4 * k, 4);
    if (numbers[0] != 1)
        return gsf_fail(ctx, GSF_ERROR_UNSUPPORTED, "%s: unknown version %d of the repair loop's state", name,
                        (int)numbers[0]);
    if (numbers[5] != f->desc.windows || numbers[2] < 0 || numbers[2] > f->desc.rounds || numbers[4] < 0 ||
        numbers[4] > numbers[5] || (numbers[3] && numbers[2] >= f->desc.rounds) || numbers[6] < 0 ||
        numbers[6] > (int64_t)numbers[2] * numbers[5] + numbers[4])
        return gsf_fail(ctx, GSF_ERROR_FORMAT, "%s: the checkpoint has different rounds or windows", name);
    gsf__kept_frames active, pending;
    GSF__TRY(gsf__load_frames(ctx, name, data, size, "FIXA", &active));
    gsf__photo_set photos;
    memset(&photos, 0, sizeof photos);
    gsf_result result = gsf__frames_to_photos(ctx, f, &active, &photos);
    gsf__drop_frames(ctx, &active);
    memset(&pending, 0, sizeof pending);
    if (result == GSF_OK) result = gsf__load_frames(ctx, name, data, size, "FIXP", &pending);
    if (result == GSF_OK) result = gsf_splat_parse_trainer(ctx, f->trainer, name, data, size);
    if (result != GSF_OK) { // the fixer is unchanged
        gsf__photo_set_destroy(ctx, &photos);
        gsf__drop_frames(ctx, &pending);
        return result;
    }
    gsf__restored_take(ctx, f->trainer, &photos);
    gsf__close_references(ctx, f);
    gsf__drop_frames(ctx, &f->pending);
    f->pending = pending;
    f->round = numbers[2];
    f->restoring = numbers[3] != 0;
    f->window = numbers[4];
    f->skipped = numbers[6];
    f->planned = 0; // the path only depends on views, round and seed, so it is not saved
    return GSF_OK;
}

// ---- >>few views ---------------------------------------------------------------

GSF_API gsf_result gsf_splat_load_train_views(gsf_context* ctx, gsf_scene* scene, const uint32_t* views, size_t view_count,
                                              gsf_train_view** out) {
    *out = NULL;
    gsf_train_view* list = (gsf_train_view*)gsf_alloc_zeroed(ctx, view_count + 1, sizeof *list);
    if (!list) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < view_count; i++) {
        const size_t v = views ? views[i] : i;
        const gsf_result result = gsf_splat_load_view_image(ctx, scene, v);
        if (result != GSF_OK) {
            gsf_free(ctx, list);
            return result;
        }
        list[i].camera = scene->views[v].camera;
        list[i].image = scene->views[v].image;
        list[i].weight = scene->views[v].weight;
        list[i].image.owned = list[i].weight.owned = NULL;
    }
    *out = list;
    return GSF_OK;
}

enum { GSF__STREAM_POINTS = 0x72616e64 }; // differs from the trainer's streams

static gsf_initial_desc gsf__initial_desc_defaults(const gsf_initial_desc* desc, const gsf_scene* scene, size_t view_count) {
    gsf_initial_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.kind == GSF_INITIAL_AUTO)
        d.kind = !scene->point_count ? GSF_INITIAL_RANDOM : view_count < 2 ? GSF_INITIAL_BOTH : GSF_INITIAL_DENSE;
    d.sh_degree = d.sh_degree == 0 ? 3 : d.sh_degree < 0 ? 0 : d.sh_degree;
    if (d.random_points == 0) d.random_points = 20000;
    d.visibility.method = d.kind == GSF_INITIAL_RAYS     ? GSF_VISIBILITY_RAYS
                          : d.kind == GSF_INITIAL_TRACKS ? GSF_VISIBILITY_TRACKS
                                                         : GSF_VISIBILITY_BOTH;
    d.visibility = gsf__visibility_desc_defaults(&d.visibility);
    d.dense = gsf__dense_desc_defaults(&d.dense);
    d.dense.seed = d.seed;
    d.dense.skip_sparse = 1;
    if (d.dense.max_points == 0) d.dense.max_points = 40000;
    return d;
}

typedef struct gsf__colored_points {
    size_t count;
    double* points;  // (count,3)
    uint8_t* colors; // (count,3)
} gsf__colored_points;

static gsf_result gsf__make_points(gsf_context* ctx, size_t count, gsf__colored_points* out) {
    out->count = count;
    out->points = (double*)gsf_alloc(ctx, count + 1, 3 * sizeof *out->points);
    out->colors = (uint8_t*)gsf_alloc(ctx, count + 1, 3);
    return out->points && out->colors ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
}

// A random point in the view's frustum, at 0.3 to 2 times the depth of the focus, uniform in volume. It takes the
// colour of the pixel it projects to, or grey where the photo's weight is below 0.5.
static void gsf__random_point(const gsf_scene_view* view, const double* focus, uint64_t seed, uint64_t i, double point[3],
                              uint8_t color[3]) {
    const gsf_camera* camera = &view->camera;
    double c2w[16], x, y, depth = 1.0;
    gsf_get_camera_c2w(camera, c2w);
    if (!focus || !gsf_project_point(camera, focus, &x, &y, &depth)) depth = 1.0;
    const double least = 0.3 * depth, most = 2.0 * depth, a = least * least * least;
    const double z = gsf__cbrt_f64(a + (most * most * most - a) * gsf_draw_uniform(seed, GSF__STREAM_POINTS, 3 * i));
    const double u = camera->width * gsf_draw_uniform(seed, GSF__STREAM_POINTS, 3 * i + 1);
    const double v = camera->height * gsf_draw_uniform(seed, GSF__STREAM_POINTS, 3 * i + 2);
    x = (u - camera->cx) / camera->fx * z;
    y = (v - camera->cy) / camera->fy * z;
    const gsf_image *image = &view->image, *weight = &view->weight;
    const uint8_t* pixel = (const uint8_t*)image->data + (int64_t)v * image->stride_y + (int64_t)u * image->stride_x;
    const int counts = !weight->data || ((const uint8_t*)weight->data)[(int64_t)v * weight->stride_y +
                                                                       (int64_t)u * weight->stride_x] >= 128;
    for (int k = 0; k < 3; k++) {
        point[k] = c2w[k] * x + c2w[4 + k] * y + c2w[8 + k] * z + c2w[12 + k];
        color[k] = counts ? pixel[k * image->stride_c] : 128;
    }
}

// Random points around the focus of all views; the views take turns.
static gsf_result gsf__random_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                     const gsf_initial_desc* desc, gsf__colored_points* out) {
    if (desc->random_points < 1 || view_count == 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "initial splats: cannot place %d random points in %zu views",
                        (int)desc->random_points, view_count);
    for (size_t i = 0; i < view_count; i++)
        if (views[i] >= scene->view_count || !scene->views[views[i]].image.data)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "initial splats: the image of view %u is not loaded", views[i]);
    double* poses = (double*)gsf_alloc(ctx, view_count, 16 * sizeof *poses);
    if (!poses) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < view_count; i++) gsf_get_camera_c2w(&scene->views[views[i]].camera, poses + 16 * i);
    double focus[3] = {0.0, 0.0, 0.0};
    const int has_focus = gsf_traj_find_focus(ctx, poses, view_count, focus) == GSF_OK;
    gsf_free(ctx, poses);
    GSF__TRY(gsf__make_points(ctx, (size_t)desc->random_points, out));
    for (size_t i = 0; i < out->count; i++)
        gsf__random_point(&scene->views[views[i % view_count]], has_focus ? focus : NULL, desc->seed, i,
                          out->points + 3 * i, out->colors + 3 * i);
    return GSF_OK;
}

// Concatenates the scene's points marked in `keep` and the dense points.
static gsf_result gsf__merge_points(gsf_context* ctx, const gsf_scene* scene, const uint8_t* keep, const gsf_dense* dense,
                                    gsf__colored_points* out) {
    size_t n = 0;
    for (size_t i = 0; i < scene->point_count; i++) n += keep[i] != 0;
    GSF__TRY(gsf__make_points(ctx, n + dense->count, out));
    n = 0;
    for (size_t i = 0; i < scene->point_count; i++) {
        if (!keep[i]) continue;
        memcpy(out->points + 3 * n, scene->points + 3 * i, 3 * sizeof *out->points);
        memcpy(out->colors + 3 * n, scene->colors + 3 * i, 3);
        n++;
    }
    if (dense->count) {
        memcpy(out->points + 3 * n, dense->points, dense->count * 3 * sizeof *out->points);
        memcpy(out->colors + 3 * n, dense->colors, dense->count * 3);
    }
    return GSF_OK;
}

static gsf_result gsf__dense_and_kept(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                      const gsf_initial_desc* desc, const uint8_t* keep, gsf__colored_points* out,
                                      gsf_initial_stats* stats) {
    gsf_dense dense;
    GSF__TRY(gsf_splat_make_dense(ctx, scene, views, view_count, keep, &desc->dense, &dense, &stats->dense));
    gsf_result result = gsf__merge_points(ctx, scene, keep, &dense, out);
    stats->new_points = dense.count;
    if (result == GSF_OK && out->count == 0)
        result = gsf_fail(ctx, GSF_ERROR_DEGENERATE, "initial splats: none of the %zu views sees a point of the scene, "
                          "and no two of them agree anywhere (try random points)", view_count);
    gsf_splat_destroy_dense(ctx, &dense);
    return result;
}

// The points of every kind except GSF_INITIAL_RANDOM: those of the scene that `keep` marks or, for GSF_INITIAL_DENSE, these
// and the dense ones, in `merged`.
static gsf_result gsf__scene_points(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views, size_t view_count,
                                    const gsf_initial_desc* d, uint8_t* keep, gsf__colored_points* merged,
                                    gsf_initial_stats* stats) {
    if (scene->point_count == 0 && d->kind != GSF_INITIAL_DENSE)
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "%s: the scene has no points (try random points)",
                        scene->folder ? scene->folder : "initial splats");
    if (d->kind == GSF_INITIAL_ALL) memset(keep, 1, scene->point_count);
    else GSF__TRY(gsf_splat_filter_points(ctx, scene, views, view_count, &d->visibility, keep, &stats->visibility));
    for (size_t i = 0; i < scene->point_count; i++) stats->scene_points += keep[i] != 0;
    if (d->kind == GSF_INITIAL_DENSE) return gsf__dense_and_kept(ctx, scene, views, view_count, d, keep, merged, stats);
    if (stats->scene_points == 0)
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "initial splats: none of the %zu views sees a point of "
                        "the scene (try all points, or random ones)", view_count);
    return GSF_OK;
}

GSF_API gsf_result gsf_splat_make_initial_splats(gsf_context* ctx, const gsf_scene* scene, const uint32_t* views,
                                                 size_t view_count, const gsf_initial_desc* desc, gsf_splats* out,
                                                 gsf_initial_stats* stats) {
    gsf_initial_stats ignored;
    if (!stats) stats = &ignored;
    memset(stats, 0, sizeof *stats);
    memset(out, 0, sizeof *out);
    const gsf_initial_desc d = gsf__initial_desc_defaults(desc, scene, view_count);
    stats->used = d;
    if (d.sh_degree > 3 || (int)d.kind < 0 || d.kind > GSF_INITIAL_RANDOM || (!views && view_count != scene->view_count))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "initial splats: invalid kind %d, SH degree %d or views (%zu of %zu)",
                        (int)d.kind, (int)d.sh_degree, view_count, scene->view_count);
    gsf__colored_points made; // random, or dense with those of the scene
    memset(&made, 0, sizeof made);
    gsf__arena arena = {ctx, NULL, 0};
    uint8_t* keep = (uint8_t*)gsf__arena_alloc_zeroed(&arena, scene->point_count, 1);
    uint32_t* all = (uint32_t*)gsf__arena_alloc(&arena, view_count, sizeof *all);
    gsf_result result = arena.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    for (size_t i = 0; all && i < view_count; i++) all[i] = views ? views[i] : (uint32_t)i;
    if (result == GSF_OK && d.kind == GSF_INITIAL_RANDOM) {
        result = gsf__random_points(ctx, scene, all, view_count, &d, &made);
        stats->new_points = made.count;
    } else if (result == GSF_OK) {
        result = gsf__scene_points(ctx, scene, all, view_count, &d, keep, &made, stats);
    }
    if (result == GSF_OK && made.points)
        result = gsf_splat_make_from_points(ctx, made.points, made.colors, made.count, NULL, d.sh_degree, scene->origin, out);
    else if (result == GSF_OK)
        result = gsf_splat_make_from_points(ctx, scene->points, scene->colors, scene->point_count, keep, d.sh_degree,
                                            scene->origin, out);
    gsf_free(ctx, made.points);
    gsf_free(ctx, made.colors);
    gsf__arena_free(&arena);
    return result;
}

GSF_API float gsf_splat_measure_near_plane(const gsf_camera* cameras, size_t stride, size_t count) {
    const double near_plane = 0.01 * 1.1 * gsf__camera_spread(cameras, stride, count);
    return near_plane > 1e-6 && near_plane < 0.2 ? (float)near_plane : 0.2f;
}

GSF_API gsf_fix_desc gsf_splat_resolve_few_view_desc(const gsf_scene* scene, size_t view_count, gsf_quality quality) {
    const float strength = view_count <= 3 ? 2.0f : view_count < 6 ? 6.0f / (float)view_count : 1.0f;
    const float growth = view_count <= 6 ? 0.0f : view_count < 9 ? ((float)view_count - 6.0f) / 3.0f : 1.0f;
    gsf_fix_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.train.iterations = 1200;
    desc.train.dropout = 0.1f * strength;
    desc.train.opacity_decay = 0.002f * strength;
    desc.train.lr_scales = 0.005f * (1.0f + growth); // faster, large splats in wrong places would explain fewer photos
    desc.train.depth_smoothness = 0.5f;
    desc.train.background_kind = GSF_BACKGROUND_PHOTOS;
    desc.train.lazy_adam = quality == GSF_QUALITY_FAST;
    desc.skip_psnr = quality == GSF_QUALITY_EXACT ? 0.0f : quality == GSF_QUALITY_FAST ? 36.0f : 45.0f;
    desc.max_pixels = quality == GSF_QUALITY_FAST ? 320 * 240 : 0;
    if (!scene) return desc;
    desc.points = scene->points;
    desc.point_count = scene->point_count;
    if (scene->view_count)
        desc.train.render.near_plane = gsf_splat_measure_near_plane(&scene->views->camera, sizeof *scene->views,
                                                                    scene->view_count);
    return desc;
}

GSF__END_IMPLEMENTATION

#endif // GSF__ISA
#endif // GSF_SPLAT_IMPLEMENTED
#endif // GSFIXER_SPLAT_IMPLEMENTATION
