/* gsfixer_traj.h - cameras and camera paths: pure functions on caller memory
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       #define GSFIXER_TRAJ_IMPLEMENTATION   // in one file; or GSFIXER_IMPLEMENTATION for everything included
       #include "gsfixer_traj.h"             // includes gsfixer.h, whose implementation is needed as well

   WHAT IT DOES NOT DO
       It allocates nothing and reads no file. It does not look at images or points to keep a path out of walls. It has
       no smoothing splines (FITPACK's s > 0): its splines pass through their poses.

   CONVENTIONS (beside those of gsfixer.h)
       pose            camera to world, double[16], column-major, OpenCV axes: column 0 right, 1 down, 2 forward,
                       3 position. An array of n poses is (n,16). Not to be mixed up with gsf_camera.w2c, its inverse.
       similarity      double[16], column-major: scale * rotation | translation, last row 0 0 0 1
       angles          radians unless the name says degrees
       unit            the normalised frame, in which the median camera is at distance 1 from the middle of the scene;
                       weights that add lengths to angles (nearest view, axis_length) are meant for that frame

   STEP BY STEP
       gsf_traj_path_desc desc;                         // all zero: reference-guided, windows of 49 frames
       memset(&desc, 0, sizeof desc);
       desc.points = scene.points; desc.point_count = scene.point_count;   // or none
       desc.round = 2; desc.seed = 1;
       gsf_traj_path_layout layout;
       if (gsf_traj_query_path(&ctx, camera_count, &desc, &layout) != GSF_OK) ...
       void* scratch = malloc(layout.scratch_bytes);
       gsf_camera* path = malloc(layout.frame_count * sizeof *path);
       int32_t* reference = malloc(layout.frame_count * sizeof *reference);
       if (gsf_traj_sample_path(&ctx, cameras, camera_count, &desc, scratch, path, reference) != GSF_OK) ...

   PATHS       gsf_traj_sample_path does all of it: normalise, sample, map back to the world. Three kinds:
               reference    (GSFixer) each window leaves a photo, joins the ellipse, follows it, and ends in the photo that
                            is nearest to where it left the ellipse. 49 = 16 + 17 + 16 frames; any other length works.
               ellipse      round the scene, looking at the point nearest to all optical axes
               interpolate  through the cameras in their given order
   OFFICIAL    The released code has quirks. `official` reproduces them to rounding; zero is the corrected behaviour:
               - legs ref -> ellipse have u = 0, 1/16 .. 14/16, 1 and then the same pose again; here u is even and no
                 pose is given twice
               - legs interpolate three points of the pose linearly, which fails for opposite directions; here positions
                 are linear and rotations slerp
               - windows follow a table over an open sequence of poses; here they are spread evenly over the closed loop
               - the similarity finds the middle nearest to the world's origin, so it depends on where that is; here
                 nearest to the mean camera position, so paths follow their scene wherever it lies
               - frames all have the first camera's intrinsics; here a frame that is a photo's has the photo's
               One thing is corrected in both: views exactly upside down are turned by half a turn, where the released
               code mirrors the world.
   ERRORS      GSF_ERROR_NUMERIC for NaN and infinity anywhere in the input, GSF_ERROR_DEGENERATE where the geometry does
               not say what to do (one view, parallel axes, coincident cameras, a view along its up vector),
               GSF_ERROR_INVALID_ARGUMENT for the rest. Never a pose that is not a rotation: columns are orthonormal to
               1e-12. On an error outputs are unspecified but for layouts and indices, which are zeroed.
   MEMORY      None of its own. `scratch` is the caller's: aligned for double, of as many bytes as the function named
               beside it returns (SIZE_MAX where that would overflow), contents of no meaning before and after.
               Inputs and outputs must not overlap unless said.
   THREADS     Pure functions; the context is only used for error texts.
   SECTIONS    >>vectors >>order statistics >>eigen >>intrinsics >>poses >>rotations >>views >>normalisation >>splines
               >>ellipse >>windows >>legs >>schedule >>paths
   SOURCES     GSFixer (its released code: datasets/normalize.py, outpaint/sample_utils.py, sparse.py, base.py),
               multinerf camera_utils (ellipse, focus point), de Boor (B-splines), Shoemake 1985 (slerp)
*/
#ifndef GSF_TRAJ_INCLUDED
#define GSF_TRAJ_INCLUDED

#include "gsfixer.h"

#ifdef __cplusplus
extern "C" {
#endif

// ---- intrinsics ----------------------------------------------------------------

// Field of view of `pixels` pixels at a focal length in pixels, and back.
GSF_API double gsf_traj_fov_from_focal(double focal, double pixels);
GSF_API double gsf_traj_focal_from_fov(double fov, double pixels);
// The camera of a model at an image reduced by `factor` (>= 1) whose file turned out to be width x height: intrinsics are
// divided by factor, then scaled by actual / (model size div factor), as the official parser does. For factor 1 it is
// gsf_camera_resized.
GSF_API gsf_camera gsf_traj_reduce_camera(const gsf_camera* camera, int32_t factor, int32_t width, int32_t height);
// The part of the image that starts at pixel (x, y): the principal point moves.
GSF_API gsf_camera gsf_traj_crop_camera(const gsf_camera* camera, int32_t x, int32_t y, int32_t width, int32_t height);
// Clip matrix (column-major, z in [0, w], w = camera depth) with the principal point's shift; times w2c it is the official
// full projection (near 0.01, far 100). Needs 0 < near_plane < far_plane.
GSF_API GSF_NODISCARD gsf_result gsf_traj_projection(gsf_context* ctx, const gsf_camera* camera, double near_plane,
                                                     double far_plane, double out[16]);

// ---- poses ---------------------------------------------------------------------

// Finite, rigid (1e-4), no reflection? Otherwise the error names the pose.
GSF_API GSF_NODISCARD gsf_result gsf_traj_check_poses(gsf_context* ctx, const double* poses, size_t count);
// The pose at `eye` that looks at `target`; `up` is the world direction that points up in the image.
GSF_API GSF_NODISCARD gsf_result gsf_traj_look_at(gsf_context* ctx, const double eye[3], const double target[3],
                                                  const double up[3], double pose[16]);
// The same from directions: forward becomes column 2, down the side to which column 1 points (official `viewmatrix`).
GSF_API GSF_NODISCARD gsf_result gsf_traj_view_pose(gsf_context* ctx, const double forward[3], const double down[3],
                                                    const double position[3], double pose[16]);
// Unit quaternion (w x y z, w >= 0) of a pose's rotation, and back (any non-zero length; position untouched).
GSF_API void gsf_traj_pose_quat(const double pose[16], double quat[4]);
GSF_API GSF_NODISCARD gsf_result gsf_traj_set_pose_quat(gsf_context* ctx, const double quat[4], double pose[16]);
// Spherical interpolation of unit quaternions along the shorter arc; t beyond [0,1] goes on. Half a turn apart: one of the
// two arcs.
GSF_API void gsf_traj_slerp(const double a[4], const double b[4], double t, double out[4]);
// Position linear, rotation slerp. out may be a or b.
GSF_API GSF_NODISCARD gsf_result gsf_traj_slerp_pose(gsf_context* ctx, const double a[16], const double b[16], double t,
                                                     double out[16]);

// ---- sets of views -------------------------------------------------------------

// Least-squares point nearest to all optical axes. Degenerate for one view and for parallel axes.
GSF_API GSF_NODISCARD gsf_result gsf_traj_focus_point(gsf_context* ctx, const double* poses, size_t count,
                                                      double focus[3]);
// Mean position, mean forward, mean down. official: looks the opposite way, as the released average_pose does.
GSF_API GSF_NODISCARD gsf_result gsf_traj_average_pose(gsf_context* ctx, const double* poses, size_t count,
                                                       int32_t official, double pose[16]);
// Poses relative to their average pose; transform = inverse of that. out may be poses.
GSF_API GSF_NODISCARD gsf_result gsf_traj_recenter_poses(gsf_context* ctx, const double* poses, size_t count,
                                                         int32_t official, double* out, double transform[16]);
// Mean camera position and the largest distance from it. The official scene_scale is radius of all cameras,
// cameras_extent is 1.1 times radius of the training cameras.
GSF_API GSF_NODISCARD gsf_result gsf_traj_camera_radius(gsf_context* ctx, const double* poses, size_t count,
                                                        double center[3], double* radius);
// Index of the view with the smallest score |position difference| + direction_weight * (1 - forward . forward); the lowest
// index among equals (to 1e-9). scores: NULL or (count). The official weight is 0.5, in the normalised frame.
GSF_API GSF_NODISCARD gsf_result gsf_traj_nearest_view(gsf_context* ctx, const double pose[16], const double* poses,
                                                       size_t count, double direction_weight, int32_t* index,
                                                       double* scores);

// ---- normalisation -------------------------------------------------------------

typedef enum gsf_traj_center {
    GSF_TRAJ_CENTER_FOCUS = 0, // median of the points of the optical axes nearest to the mean camera position
    GSF_TRAJ_CENTER_POSES,     // median camera position
} gsf_traj_center;

typedef struct gsf_traj_similarity_desc {
    gsf_traj_center center;
    int32_t strict_scaling; // the farthest camera comes to distance 1; zero: the median camera
    int32_t official;       // FOCUS: points of the axes nearest to the world's origin
} gsf_traj_similarity_desc;

// T that turns the mean camera up vector (minus column 1) to world -y, moves the middle to 0 and scales cameras to
// distance 1 (official similarity_from_cameras). Degenerate where up vectors cancel or all cameras are in the middle.
GSF_API size_t gsf_traj_similarity_scratch(size_t count);
GSF_API GSF_NODISCARD gsf_result gsf_traj_similarity(gsf_context* ctx, const double* poses, size_t count,
                                                     const gsf_traj_similarity_desc* desc, void* scratch,
                                                     double transform[16]);
// Rigid T that moves the points' median to 0 and their principal axes to x, y, z by falling variance (official
// align_principle_axes). The sign that an eigenvector lacks: the largest component of rows 0 and 1 is positive, the
// determinant is +1. points (count,3). Degenerate for coincident and collinear points.
GSF_API size_t gsf_traj_principal_axes_scratch(size_t count);
GSF_API GSF_NODISCARD gsf_result gsf_traj_principal_axes(gsf_context* ctx, const double* points, size_t count,
                                                         void* scratch, double transform[16]);
// Similarity, then principal axes of the points (NULL: of the camera positions; where these lie on a line, the mean up
// vector decides the third axis). `transform` is the product, as the official parser has it.
GSF_API size_t gsf_traj_normalize_scratch(size_t count, size_t point_count);
GSF_API GSF_NODISCARD gsf_result gsf_traj_normalize(gsf_context* ctx, const double* poses, size_t count,
                                                    const double* points, size_t point_count,
                                                    const gsf_traj_similarity_desc* desc, void* scratch,
                                                    double transform[16]);
// Principal axes of the positions about their mean, y down on average, largest coordinate 1 (official transform_poses_pca;
// the same sign rule). out may be poses.
GSF_API GSF_NODISCARD gsf_result gsf_traj_pca_poses(gsf_context* ctx, const double* poses, size_t count, double* out,
                                                    double transform[16]);
// Applies a similarity; rotations stay rotations. out may be the input.
GSF_API void gsf_traj_transform_poses(const double transform[16], const double* poses, size_t count, double* out);
GSF_API void gsf_traj_transform_points(const double transform[16], const double* points, size_t count, double* out);
// Inverse of a similarity; fails where it is none.
GSF_API GSF_NODISCARD gsf_result gsf_traj_invert_similarity(gsf_context* ctx, const double transform[16],
                                                            double out[16]);

// ---- splines -------------------------------------------------------------------

// Interpolating B-spline of `degree` (1..5, at most count - 1) through values (count,dims) at strictly ascending sites,
// not-a-knot ends (knots as FITPACK with s = 0 and scipy's make_interp_spline place them). Evaluated at `at` (at_count),
// which is clamped to the sites' range; out (at_count,dims).
GSF_API size_t gsf_traj_spline_scratch(size_t count, int32_t degree, size_t dims);
GSF_API GSF_NODISCARD gsf_result gsf_traj_spline(gsf_context* ctx, const double* sites, const double* values,
                                                 size_t count, size_t dims, int32_t degree, const double* at,
                                                 size_t at_count, void* scratch, double* out);

typedef struct gsf_traj_spline_desc {
    int32_t frames_per_leg; // 16
    int32_t degree;         // 5 (lowered to count - 1)
    double axis_length;     // 0.1: arm of the look-at and up points beside the position
} gsf_traj_spline_desc;

// Spline through (position, position - arm * forward, position + arm * down) of the poses, by chord length; frames_per_leg
// * (count - 1) poses, the last one excluded (official generate_interpolated_path with smoothness 0; the same for two
// poses whatever the smoothness). Degenerate where neighbouring poses coincide or directions cancel.
GSF_API size_t gsf_traj_spline_path_scratch(size_t count, const gsf_traj_spline_desc* desc);
GSF_API GSF_NODISCARD gsf_result gsf_traj_spline_path(gsf_context* ctx, const double* poses, size_t count,
                                                      const gsf_traj_spline_desc* desc, void* scratch, double* out);

// Positions by a spline over even sites (degree 1, 2, 3 for 2, 3, more views), rotations slerp, then each pose moved by
// `push` along its forward axis (official interpolate_camera_path, which draws push from [0, 0.5)). `frames` poses (>= 1),
// both ends included.
GSF_API size_t gsf_traj_slerp_path_scratch(size_t count);
GSF_API GSF_NODISCARD gsf_result gsf_traj_slerp_path(gsf_context* ctx, const double* poses, size_t count, int32_t frames,
                                                     double push, void* scratch, double* out);

// From pose to pose with straight positions: (count - 1) * (frames_per_leg - 1) + 1 poses, both ends included (official
// interp_traj). official: the released spacing u = 0, 1/n .. (n-2)/n of each leg, n = frames_per_leg >= 2, and its
// interpolation of axes, arm 0.1; zero: even spacing, slerp.
GSF_API GSF_NODISCARD gsf_result gsf_traj_leg_path(gsf_context* ctx, const double* poses, size_t count,
                                                   int32_t frames_per_leg, int32_t official, double* out);

// ---- ellipse -------------------------------------------------------------------

typedef struct gsf_traj_ellipse_desc {
    int32_t frames;       // 85
    double z_variation;   // share of the cameras' height range (10th to 90th percentile) swept; 0 = flat, at z = 0
    double z_phase;       // [0,1): where on the loop the height starts
    double pitch_degrees; // every view is turned by this about its own x axis
} gsf_traj_ellipse_desc;

// The official parameters of an outpaint round: z_variation max(0.5, 1.5 - 0.2 round), pitch 2 degrees * round, a random
// z_phase (from seed and round). frames 0 = 85.
GSF_API gsf_traj_ellipse_desc gsf_traj_round_ellipse(int32_t round, uint64_t seed, int32_t frames);
// Closed loop in the xy plane about the focus point of the poses, which must be normalised. Half axes are 1.2 times the
// 90th percentile of |position - focus|; views look at the focus; down is the axis nearest to the mean column 1.
GSF_API size_t gsf_traj_ellipse_scratch(size_t count);
GSF_API GSF_NODISCARD gsf_result gsf_traj_ellipse_path(gsf_context* ctx, const double* poses, size_t count,
                                                       const gsf_traj_ellipse_desc* desc, void* scratch, double* out);

// ---- windows and schedule ------------------------------------------------------

// Frames of one window: `side` from the first reference to the ellipse, `middle` on it, `side` to the last reference.
// middle + 2 side = window_length; 49 gives 16 and 17. Needs window_length >= 2.
GSF_API void gsf_traj_split_window(int32_t window_length, int32_t* side, int32_t* middle);
// The released table of overlapping windows of `middle` poses over a sequence of `total`: starts and overlaps (NULL = only
// the count is wanted). Fails where the table leaves the sequence (total < middle, mostly).
GSF_API GSF_NODISCARD gsf_result gsf_traj_official_windows(gsf_context* ctx, int32_t total, int32_t middle,
                                                           int32_t* starts, int32_t* overlaps, int32_t* count);
// Weight of the generative loss, between iterations start and until (0 elsewhere): lambda * sin(x), x from 0 to pi
// (official: falls again in the second half) or to pi/2 (the paper: gradually increased).
GSF_API double gsf_traj_generative_weight(int64_t iteration, int64_t start, int64_t until, double lambda,
                                          int32_t official);
// Iterations at which a repair round is made: start, start + every, ... up to `until`. rounds: NULL or up to *count.
GSF_API void gsf_traj_repair_rounds(int64_t start, int64_t every, int64_t until, int64_t* rounds, size_t* count);

// ---- paths ---------------------------------------------------------------------

typedef enum gsf_traj_kind {
    GSF_TRAJ_REFERENCE = 0, // photo -> ellipse -> nearest photo, per window
    GSF_TRAJ_ELLIPSE,       // windows are consecutive pieces of the loop
    GSF_TRAJ_INTERPOLATE,   // windows are consecutive pieces of a path through the cameras in their order
} gsf_traj_kind;

typedef struct gsf_traj_path_desc {
    gsf_traj_kind kind;
    int32_t window_length;   // frames per window, at least 2; 0 = 49
    int32_t window_count;    // 0 = 7, for INTERPOLATE cameras - 1. One window takes the whole loop, or path
    int32_t ellipse_poses;   // poses of the whole loop; 0 = REFERENCE: 5/7 of what the windows take, so that neighbours
                             // overlap (85 for 7 windows of 49 frames); ELLIPSE: all windows together are one loop
    int32_t round;           // repair round, from 0: changes height, tilt and phase of the ellipse
    uint64_t seed;
    const double* points;    // (point_count,3) world points for the principal axes, borrowed; NULL = camera positions
    size_t point_count;
    const double* transform; // world to normalised frame, [16], for a host that has it from more cameras than these;
                             // NULL = gsf_traj_normalize of these cameras and points
    const gsf_camera* intrinsics; // size and intrinsics of the frames; NULL = those of the first camera
    int32_t official;        // REFERENCE: the released windows (length 3n+1, count by its table over ellipse_poses = 85),
                             // spacing and interpolation; all kinds: the released similarity. See OFFICIAL above
} gsf_traj_path_desc;

typedef struct gsf_traj_path_layout { // everything resolved
    int32_t window_count, window_length, ellipse_poses;
    size_t frame_count;   // window_count * window_length
    size_t scratch_bytes; // for gsf_traj_sample_path with as many cameras and points
} gsf_traj_path_layout;

GSF_API GSF_NODISCARD gsf_result gsf_traj_query_path(gsf_context* ctx, size_t camera_count,
                                                     const gsf_traj_path_desc* desc, gsf_traj_path_layout* layout);
// Samples a path for world cameras (camera_count). out (frame_count): window after window, in world coordinates, all of
// one size. reference_index (frame_count) or NULL: the camera whose photo a frame is, else -1; REFERENCE windows start and
// end with one. Such a frame has that camera's w2c bit for bit.
// ELLIPSE and REFERENCE need two cameras whose axes are not parallel, INTERPOLATE two cameras.
GSF_API GSF_NODISCARD gsf_result gsf_traj_sample_path(gsf_context* ctx, const gsf_camera* cameras, size_t camera_count,
                                                      const gsf_traj_path_desc* desc, void* scratch, gsf_camera* out,
                                                      int32_t* reference_index);

#ifdef __cplusplus
}
#endif

#endif // GSF_TRAJ_INCLUDED

// ================================================================================
// The API ends here. What follows is the implementation.
// ================================================================================

#if defined(GSFIXER_IMPLEMENTATION) && !defined(GSFIXER_TRAJ_IMPLEMENTATION)
#define GSFIXER_TRAJ_IMPLEMENTATION
#endif
#if defined(GSFIXER_TRAJ_IMPLEMENTATION) || defined(__INTELLISENSE__) || defined(__JETBRAINS_IDE__)
#ifndef GSF_TRAJ_IMPLEMENTED
#define GSF_TRAJ_IMPLEMENTED

#include "gsfixer.h" // again: its internals, if all was included before without an implementation macro

GSF__BEGIN_IMPLEMENTATION

GSF__END_IMPLEMENTATION

#endif // GSF_TRAJ_IMPLEMENTED
#endif // GSFIXER_TRAJ_IMPLEMENTATION
