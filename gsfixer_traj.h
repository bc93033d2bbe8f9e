/* gsfixer_traj.h - cameras and camera paths: pure functions on caller memory
   SPDX-License-Identifier: MIT

   HOW TO INCLUDE
       #define GSFIXER_TRAJ_IMPLEMENTATION   // in one file; or GSFIXER_IMPLEMENTATION for everything included
       #include "gsfixer_traj.h"             // includes gsfixer.h, whose implementation is needed as well

   WHAT IT DOES NOT DO
       It allocates no memory and reads no files. It does not avoid obstacles: a path may pass through walls (only the
       path `spread` keeps its distance from the points). It has no smoothing splines (FITPACK's s > 0): its splines
       interpolate their poses.

   CONVENTIONS (in addition to those of gsfixer.h)
       pose            camera to world, double[16], column-major, OpenCV axes: column 0 right, 1 down, 2 forward,
                       3 position. An array of n poses is (n,16). Do not confuse it with its inverse, gsf_camera.w2c.
       similarity      double[16], column-major: scale * rotation | translation, last row 0 0 0 1
       angles          radians unless the name says degrees
       unit            of the normalised frame, in which the median camera is at distance 1 from the centre of the scene;
                       weights that add lengths to angles (nearest view, axis_length) refer to that frame

   STEP BY STEP
       gsf_traj_path_desc desc;                         // all zero: reference-guided, windows of 49 frames
       memset(&desc, 0, sizeof desc);
       desc.points = scene.points; desc.point_count = scene.point_count;   // or none
       desc.round = 2; desc.seed = 1;
       gsf_traj_path_info layout;
       if (gsf_traj_query_path(&ctx, camera_count, &desc, &layout) != GSF_OK) ...
       void* scratch = malloc(layout.scratch_bytes);
       gsf_camera* path = malloc(layout.frame_count * sizeof *path);
       int32_t* reference = malloc(layout.frame_count * sizeof *reference);
       if (gsf_traj_sample_path(&ctx, cameras, camera_count, &desc, scratch, path, reference) != GSF_OK) ...

   PATHS       gsf_traj_sample_path normalises the scene, samples the path and maps it back to the world. Four kinds:
               reference    (GSFixer) each window starts at a photo, joins the ellipse, follows it, and ends at the photo
                            nearest to the point where it leaves the ellipse. 49 = 16 + 17 + 16 frames; any other length
                            works as well.
               ellipse      around the scene, looking at the point nearest to all optical axes
               interpolate  through the cameras in the given order
               spread       (ours) a sweep through the space around the cameras that looks where they look: for restorers
                            that take each frame by itself. Every round has other frames
   OFFICIAL    The code of the GSFixer release has quirks. The field `official` reproduces them up to rounding; zero
               selects the corrected behaviour:
               - legs from a photo to the ellipse have u = 0, 1/16 .. 14/16, 1 and then repeat the pose; corrected: u is
                 evenly spaced and no pose is repeated
               - legs interpolate three points of the pose linearly, which fails for opposite directions; corrected:
                 linear positions and slerped rotations
               - windows follow a table over an open sequence of poses; corrected: they are spread evenly over the closed
                 loop
               - the similarity uses the points of the optical axes nearest to the world's origin and so depends on it;
                 corrected: nearest to the mean camera position, so that paths do not depend on the choice of origin
               - all frames have the first camera's intrinsics; corrected: a frame at a photo's pose has that photo's
               One quirk is corrected in both: exactly upside-down views are rotated by half a turn, where the release
               mirrors the world.
               Functions marked GSF__GOLDEN are not part of these paths (other splines and alignments of the release, and
               steps of the paths one by one). They are next to the code that they share, and tests/golden_traj.c checks
               them, and with them that code, against data of the release.
   ERRORS      GSF_ERROR_NUMERIC for NaN and infinity anywhere in the input, GSF_ERROR_DEGENERATE if the geometry does not
               determine a result (one view, parallel axes, coincident cameras, a view along its up vector),
               GSF_ERROR_INVALID_ARGUMENT otherwise. The rotation of every returned pose is orthonormal to 1e-12. On an
               error, outputs are unchanged or zeroed.
   MEMORY      Allocates nothing. `scratch` belongs to the caller: aligned for double, layout.scratch_bytes long, contents
               undefined before and after the call. Inputs and outputs must not overlap unless stated.
   THREADS     Pure functions; the context is used for error messages only.
   SECTIONS    >>vectors >>order statistics >>eigen >>poses >>rotations >>views >>normalisation >>splines
               >>ellipse >>windows >>legs >>schedule >>paths
   SOURCES     GSFixer (its released code: datasets/normalize.py, outpaint/sample_utils.py, sparse.py, base.py),
               multinerf's camera_utils (ellipse, focus point), de Boor (B-splines), Shoemake 1985 (slerp)
*/
#ifndef GSF_TRAJ_INCLUDED
#define GSF_TRAJ_INCLUDED

#include "gsfixer.h"

#ifdef __cplusplus
extern "C" {
#endif

// ---- poses ---------------------------------------------------------------------

// The pose at `eye` that looks at `target`; `up` is the world direction that is up in the image.
GSF_API GSF_NODISCARD gsf_result gsf_traj_look_at(gsf_context* ctx, const double eye[3], const double target[3],
                                                  const double up[3], double pose[16]);

// ---- sets of views -------------------------------------------------------------

// The point nearest to all optical axes in the least-squares sense. Degenerate for one view and for parallel axes.
GSF_API GSF_NODISCARD gsf_result gsf_traj_find_focus(gsf_context* ctx, const double* poses, size_t count,
                                                     double focus[3]);

// ---- ellipse -------------------------------------------------------------------

typedef struct gsf_traj_ellipse_desc {
    int32_t frames;       // 0 = 85
    double z_variation;   // fraction of the cameras' height range (10th to 90th percentile) covered; 0 = flat, at z = 0
    double z_phase;       // [0,1): phase of the height along the loop
    double pitch_degrees; // rotation of every view about its own x axis
} gsf_traj_ellipse_desc;

// ---- schedule ------------------------------------------------------------------

// Weight of the generative loss, 0 up to iteration start: lambda * t (2 - t) with t from 0 to 1 at `until`, constant lambda
// afterwards (the paper: "gradually increased"; computed in float32). official: lambda * sin(pi t), which decreases again in
// the second half and is 0 from `until` on.
GSF_API double gsf_traj_query_generative_weight(int64_t iteration, int64_t start, int64_t until, double lambda,
                                                int32_t official);
// Iteration of repair round `round` (from 0) of `count`: spread evenly from `first` to `last`, rounded down.
GSF_API int32_t gsf_traj_query_repair_round(int32_t first, int32_t last, int32_t count, int32_t round);

// ---- paths ---------------------------------------------------------------------

typedef enum gsf_traj_kind {
    GSF_TRAJ_REFERENCE = 0, // photo -> ellipse -> nearest photo, per window
    GSF_TRAJ_ELLIPSE,       // windows are consecutive sections of the loop
    GSF_TRAJ_INTERPOLATE,   // windows are consecutive sections of a path through the cameras in their order
    GSF_TRAJ_SPREAD,        // frames fill a box around the cameras: their own, 1.3 times as wide, but nowhere thinner than
                            // 0.3 times its diagonal. They look where the nearest cameras look, and keep a tenth of the
                            // scene's depth away from the points where they can. No frame is a camera's own view
} gsf_traj_kind;

typedef struct gsf_traj_path_desc {
    gsf_traj_kind kind;
    int32_t window_length;   // frames per window, at least 2; 0 = 49
    int32_t window_count;    // 0 = 7, for INTERPOLATE cameras - 1. A single window covers the whole loop or path
    int32_t ellipse_poses;   // poses of the whole loop; 0 = REFERENCE: 5/7 of the poses in all windows, so that neighbours
                             // overlap (85 for 7 windows of 49 frames); ELLIPSE: all windows together form one loop
    int32_t round;           // repair round, from 0: determines height, tilt and phase of the ellipse, frames of SPREAD
    uint64_t seed;
    const double* points;    // (point_count,3) world points for the principal axes (SPREAD: for the depth of the scene),
                             // borrowed; NULL = camera positions
    size_t point_count;
    const double* transform; // world to normalised frame, [16], if the host has computed it from more cameras; NULL = from
                             // these cameras and points
    const gsf_traj_ellipse_desc* ellipse; // the loop's shape (`frames` is ignored); NULL = as in the release's outpaint
                             // rounds: z_variation max(0.5, 1.5 - 0.2 round), pitch 2 degrees * round and a z_phase drawn
                             // from seed and round
    const gsf_camera* intrinsics; // size and intrinsics of the frames; NULL = those of the first camera
    int32_t official;        // REFERENCE: windows as in the release (length 3n+1, count by its table over ellipse_poses =
                             // 85), with its spacing and interpolation; all kinds: its similarity. See OFFICIAL
} gsf_traj_path_desc;

typedef struct gsf_traj_path_info { // the desc's counts with defaults filled in
    int32_t window_count, window_length, ellipse_poses;
    size_t frame_count;   // window_count * window_length
    size_t scratch_bytes; // for gsf_traj_sample_path with this number of cameras and points
} gsf_traj_path_info;

GSF_API GSF_NODISCARD gsf_result gsf_traj_query_path(gsf_context* ctx, size_t camera_count,
                                                     const gsf_traj_path_desc* desc, gsf_traj_path_info* layout);
// Samples a path for world cameras (camera_count). out (frame_count): window after window, in world coordinates, all of
// the same size. reference_index (frame_count) or NULL: the camera whose pose a frame has, else -1; such a frame has
// that camera's w2c bit for bit. REFERENCE windows start and end with one. All kinds need two cameras, ELLIPSE and
// REFERENCE at different positions. If all axes are parallel, these two look at the depth of the points in front of the
// cameras.
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

#include "gsfixer.h" // again, for its internals, in case it was first included without an implementation macro

GSF__BEGIN_IMPLEMENTATION

#define GSF__GOLDEN GSF__SHARED // called only by tests, against data of the release: see OFFICIAL above

// ---- >>vectors -----------------------------------------------------------------

static double gsf__traj_dot(const double a[3], const double b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void gsf__traj_cross(const double a[3], const double b[3], double out[3]) {
    const double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    out[0] = x;
    out[1] = y;
    out[2] = z;
}

static double gsf__traj_max_abs(const double v[3]) {
    double m = fabs(v[0]);
    if (fabs(v[1]) > m) m = fabs(v[1]);
    if (fabs(v[2]) > m) m = fabs(v[2]);
    return m;
}

// Length, without intermediate overflow or underflow.
static double gsf__traj_length(const double v[3]) {
    const double m = gsf__traj_max_abs(v);
    if (!(m > 0.0)) return 0.0;
    const double x = v[0] / m, y = v[1] / m, z = v[2] / m;
    return m * sqrt(x * x + y * y + z * z);
}

static double gsf__traj_distance(const double a[3], const double b[3]) {
    const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return gsf__traj_length(d);
}

// Unit vector; returns 0 if v has no direction (zero, NaN, infinite). out may be v.
static int gsf__traj_unit(const double v[3], double out[3]) {
    const double m = gsf__traj_max_abs(v);
    if (!(m > 0.0) || !isfinite(v[0]) || !isfinite(v[1]) || !isfinite(v[2])) return 0;
    const double s[3] = {v[0] / m, v[1] / m, v[2] / m};
    const double length = sqrt(gsf__traj_dot(s, s));
    for (int i = 0; i < 3; i++) out[i] = s[i] / length;
    return 1;
}

static void gsf__traj_identity(double m[16]) {
    memset(m, 0, 16 * sizeof(double));
    m[0] = m[5] = m[10] = m[15] = 1.0;
}

static int gsf__traj_finite(const double* v, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (!isfinite(v[i])) return 0;
    return 1;
}

static void gsf__traj_apply(const double m[16], const double p[3], double out[3]) {
    const double x = p[0], y = p[1], z = p[2];
    for (int r = 0; r < 3; r++) out[r] = m[r] * x + m[4 + r] * y + m[8 + r] * z + m[12 + r];
}

// Pose from forward and down directions; returns 0 if they are parallel. Columns are orthonormal to a few ulp: the second
// projection removes the error of the cross product of nearly parallel directions.
static int gsf__traj_axes(const double forward[3], const double down[3], const double position[3], double pose[16]) {
    double x[3], y[3], z[3], d[3];
    if (!gsf__traj_unit(forward, z) || !gsf__traj_unit(down, d)) return 0;
    gsf__traj_cross(d, z, x);
    if (!(gsf__traj_length(x) > 1e-9) || !gsf__traj_unit(x, x)) return 0;
    const double lean = gsf__traj_dot(x, z);
    for (int i = 0; i < 3; i++) x[i] -= lean * z[i];
    if (!gsf__traj_unit(x, x)) return 0;
    gsf__traj_cross(z, x, y);
    for (int i = 0; i < 3; i++) {
        pose[i] = x[i];
        pose[4 + i] = y[i];
        pose[8 + i] = z[i];
        pose[12 + i] = position[i];
    }
    pose[3] = pose[7] = pose[11] = 0.0;
    pose[15] = 1.0;
    return 1;
}

// Sizes of scratch memory, saturating at SIZE_MAX on overflow.
static size_t gsf__traj_size_mul(size_t a, size_t b) {
    size_t out;
    return a != SIZE_MAX && b != SIZE_MAX && gsf__mul_size(a, b, &out) ? out : SIZE_MAX;
}
static size_t gsf__traj_size_add(size_t a, size_t b) { return a > SIZE_MAX - b ? SIZE_MAX : a + b; }
static size_t gsf__traj_size_max(size_t a, size_t b) { return a > b ? a : b; }

// ---- >>order statistics --------------------------------------------------------

// Heap sort: in place, n log n in the worst case. The input must not contain NaN.
static void gsf__traj_sort(double* v, size_t n) {
    if (n < 2) return;
    for (size_t start = n / 2, end = n; end > 1;) {
        double value;
        if (start > 0) {
            value = v[--start];
        } else {
            value = v[--end];
            v[end] = v[0];
        }
        size_t hole = start;
        for (size_t child; (child = 2 * hole + 1) < end; hole = child) {
            if (child + 1 < end && v[child + 1] > v[child]) child++;
            if (v[child] <= value) break;
            v[hole] = v[child];
        }
        v[hole] = value;
    }
}

// Percentile of sorted values with linear interpolation (numpy's default); share in [0,1].
static double gsf__traj_percentile(const double* sorted, size_t n, double share) {
    const double at = share * (double)(n - 1);
    size_t below = (size_t)at;
    if (below > n - 1) below = n - 1;
    const size_t above = below + 1 < n ? below + 1 : below;
    return sorted[below] + (sorted[above] - sorted[below]) * (at - (double)below);
}

// numpy's median: the mean of the two middle values for even n. Sorts v.
static double gsf__traj_median(double* v, size_t n) {
    gsf__traj_sort(v, n);
    return n % 2 ? v[n / 2] : 0.5 * v[n / 2 - 1] + 0.5 * v[n / 2];
}

// ---- >>eigen -------------------------------------------------------------------

// The coordinate axis least aligned with `away`, made perpendicular to it.
static void gsf__traj_side_axis(const double away[3], double out[3]) {
    const int axis = fabs(away[0]) < 0.7 ? 0 : 1;
    for (int i = 0; i < 3; i++) out[i] = (i == axis) - away[axis] * away[i];
    (void)gsf__traj_unit(out, out);
}

// Makes eigenvectors unique where the matrix does not determine them: equal eigenvalues take coordinate axes,
// the largest component of rows 0 and 1 is positive (the first of equal ones), the determinant is +1.
static void gsf__traj_fix_axes(const double values[3], double rows[9]) {
    const double tie = 1e-7 * values[0];
    if (values[0] - values[2] <= tie) {
        for (int i = 0; i < 9; i++) rows[i] = i % 4 == 0;
    } else if (values[0] - values[1] <= tie) {
        gsf__traj_side_axis(rows + 6, rows);
        gsf__traj_cross(rows + 6, rows, rows + 3);
    } else if (values[1] - values[2] <= tie) {
        gsf__traj_side_axis(rows, rows + 3);
    }
    for (int r = 0; r < 2; r++) {
        double* row = rows + 3 * r;
        const double most = 0.999 * gsf__traj_max_abs(row);
        const int first = fabs(row[0]) >= most ? 0 : fabs(row[1]) >= most ? 1 : 2;
        if (row[first] < 0.0)
            for (int i = 0; i < 3; i++) row[i] = -row[i];
    }
    gsf__traj_cross(rows, rows + 3, rows + 6);
}

// ---- >>poses -------------------------------------------------------------------

// Checks that poses are finite, rigid (to 1e-4) and no reflections; otherwise the error names the pose.
static gsf_result gsf__traj_check_poses(gsf_context* ctx, const double* poses, size_t count) {
    if (!poses && count) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "poses: none given");
    for (size_t n = 0; n < count; n++) {
        const double* m = poses + 16 * n;
        if (!gsf__traj_finite(m, 16)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "pose %zu: a value is not finite", n);
        for (int a = 0; a < 3; a++)
            for (int b = a; b < 3; b++)
                if (!(fabs(gsf__traj_dot(m + 4 * a, m + 4 * b) - (a == b)) <= 1e-4))
                    return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "pose %zu: not rigid (columns %d, %d)", n, a, b);
        double z[3];
        gsf__traj_cross(m, m + 4, z);
        if (!(gsf__traj_dot(z, m + 8) > 0.0))
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "pose %zu: a reflection", n);
        if (m[3] != 0.0 || m[7] != 0.0 || m[11] != 0.0 || fabs(m[15] - 1.0) > 1e-12)
            return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "pose %zu: last row is not 0 0 0 1", n);
    }
    return GSF_OK;
}

// Final check of every path: coordinates near the limits of double may have overflowed.
static gsf_result gsf__traj_check_path(gsf_context* ctx, double* poses, size_t count) {
    if (gsf__traj_finite(poses, 16 * count)) return GSF_OK;
    memset(poses, 0, 16 * count * sizeof(double));
    return gsf_fail(ctx, GSF_ERROR_NUMERIC, "path: coordinates are too large to compute with");
}

// Pose from directions: forward becomes column 2, and column 1 points towards down (the release's `viewmatrix`).
static gsf_result gsf__traj_view_pose(gsf_context* ctx, const double forward[3], const double down[3],
                                      const double position[3], double pose[16]) {
    if (!gsf__traj_finite(forward, 3) || !gsf__traj_finite(down, 3) || !gsf__traj_finite(position, 3))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "view: a direction or the position is not finite");
    if (!gsf__traj_axes(forward, down, position, pose))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "view: forward and up are parallel, or one is zero");
    return GSF_OK;
}

GSF_API gsf_result gsf_traj_look_at(gsf_context* ctx, const double eye[3], const double target[3], const double up[3],
                                    double pose[16]) {
    if (!gsf__traj_finite(eye, 3) || !gsf__traj_finite(target, 3) || !gsf__traj_finite(up, 3))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "look-at: a value is not finite");
    const double forward[3] = {target[0] - eye[0], target[1] - eye[1], target[2] - eye[2]};
    const double down[3] = {-up[0], -up[1], -up[2]};
    if (!(gsf__traj_length(forward) > 1e-14 * (gsf__traj_max_abs(eye) + gsf__traj_max_abs(target))))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "look-at: target and eye coincide");
    return gsf__traj_view_pose(ctx, forward, down, eye, pose);
}

// ---- >>rotations ---------------------------------------------------------------

// Sets the rotation of a pose from a quaternion of any non-zero length; the position is unchanged.
static void gsf__traj_quat_axes(const double q[4], double pose[16]) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double s = 2.0 / (w * w + x * x + y * y + z * z);
    pose[0] = 1.0 - s * (y * y + z * z);
    pose[1] = s * (x * y + w * z);
    pose[2] = s * (x * z - w * y);
    pose[4] = s * (x * y - w * z);
    pose[5] = 1.0 - s * (x * x + z * z);
    pose[6] = s * (y * z + w * x);
    pose[8] = s * (x * z + w * y);
    pose[9] = s * (y * z - w * x);
    pose[10] = 1.0 - s * (x * x + y * y);
    pose[3] = pose[7] = pose[11] = 0.0;
    pose[15] = 1.0;
}

// Spherical interpolation of unit quaternions along the shorter arc; t outside [0,1] extrapolates. For rotations half a
// turn apart, one of the two arcs is chosen.
static void gsf__traj_slerp(const double a[4], const double b[4], double t, double out[4]) {
    double dot = 0.0, apart = 0.0, along = 0.0, q[4];
    for (int i = 0; i < 4; i++) dot += a[i] * b[i];
    const double sign = dot < 0.0 ? -1.0 : 1.0;
    for (int i = 0; i < 4; i++) {
        const double d = sign * b[i] - a[i], s = sign * b[i] + a[i];
        apart += d * d;
        along += s * s;
    }
    const double angle = 2.0 * gsf__atan2_f64(sqrt(apart), sqrt(along)); // at most a quarter turn: its sine is well conditioned
    double wa = 1.0 - t, wb = t;
    if (angle > 1e-9) {
        wa = gsf__sin_f64(angle * (1.0 - t)) / gsf__sin_f64(angle);
        wb = gsf__sin_f64(angle * t) / gsf__sin_f64(angle);
    }
    double length = 0.0;
    for (int i = 0; i < 4; i++) {
        q[i] = wa * a[i] + wb * sign * b[i];
        length += q[i] * q[i];
    }
    length = sqrt(length);
    for (int i = 0; i < 4; i++) out[i] = q[i] / length;
}

// Linear interpolation of the position, slerp of the rotation. out may be a or b.
static void gsf__traj_blend_poses(const double a[16], const double b[16], double t, double out[16]) {
    double qa[4], qb[4], q[4], position[3];
    gsf__quat_of(a, qa);
    gsf__quat_of(b, qb);
    gsf__traj_slerp(qa, qb, t, q);
    for (int i = 0; i < 3; i++) position[i] = a[12 + i] + (b[12 + i] - a[12 + i]) * t;
    gsf__traj_quat_axes(q, out);
    memcpy(out + 12, position, sizeof position);
}

// ---- >>views -------------------------------------------------------------------

static gsf_result gsf__traj_check_views(gsf_context* ctx, const char* what, const double* poses, size_t count) {
    if (count == 0) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "%s: no view", what);
    return gsf__traj_check_poses(ctx, poses, count);
}

// Mean of a column of the poses (0..3), summed as differences from the first to keep precision far from the origin.
static void gsf__traj_mean_column(const double* poses, size_t count, int column, double out[3]) {
    const double* first = poses + 4 * column;
    double sum[3] = {0.0, 0.0, 0.0};
    for (size_t n = 1; n < count; n++)
        for (int i = 0; i < 3; i++) sum[i] += poses[16 * n + (size_t)(4 * column + i)] - first[i];
    for (int i = 0; i < 3; i++) out[i] = first[i] + sum[i] / (double)count;
}

// Solves mean(M^T M) x = mean(M^T M o), M = I - d d^T, o position and d direction of a view, relative to the mean o.
// Returns the smallest eigenvalue: the mean squared sine of the angles to the common direction. If it is not above
// `least`, the axes are parallel, and the position of the focus along them is taken from `prior`.
static double gsf__traj_solve_focus(const double* poses, size_t count, double least, const double prior[3],
                                    double focus[3]) {
    double center[3], a[9], b[3], values[3], rows[9];
    memset(a, 0, sizeof a);
    memset(b, 0, sizeof b);
    gsf__traj_mean_column(poses, count, 3, center);
    for (size_t n = 0; n < count; n++) {
        const double* d = poses + 16 * n + 8;
        double m[9];
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) m[3 * r + c] = (r == c) - d[r] * d[c];
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) {
                const double entry = m[r] * m[c] + m[3 + r] * m[3 + c] + m[6 + r] * m[6 + c];
                a[3 * r + c] += entry / (double)count;
                b[r] += entry * (poses[16 * n + 12 + (size_t)c] - center[c]) / (double)count;
            }
    }
    gsf__mat3_eigen(a, values, rows);
    double x[3] = {0.0, 0.0, 0.0};
    for (int k = 0; k < 3; k++) {
        const double* row = rows + 3 * k;
        const double known[3] = {prior[0] - center[0], prior[1] - center[1], prior[2] - center[2]};
        const double share = values[k] > least ? gsf__traj_dot(row, b) / values[k] : gsf__traj_dot(row, known);
        for (int i = 0; i < 3; i++) x[i] += share * row[i];
    }
    for (int i = 0; i < 3; i++) focus[i] = center[i] + x[i];
    return values[2];
}

GSF_API gsf_result gsf_traj_find_focus(gsf_context* ctx, const double* poses, size_t count, double focus[3]) {
    const double least = 1e-12, zero[3] = {0.0, 0.0, 0.0};
    GSF__TRY(gsf__traj_check_views(ctx, "focus point", poses, count));
    if (!(gsf__traj_solve_focus(poses, count, least, zero, focus) > least))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "focus point: the %zu optical axes are parallel", count);
    if (!gsf__traj_finite(focus, 3)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "focus point: coordinates are too large");
    return GSF_OK;
}

// Mean position, mean forward, mean down. official: looks in the opposite direction, like the release's average_pose.
static gsf_result gsf__traj_average_pose(gsf_context* ctx, const double* poses, size_t count, int32_t official,
                                         double pose[16]) {
    GSF__TRY(gsf__traj_check_views(ctx, "average pose", poses, count));
    double position[3], forward[3], down[3];
    gsf__traj_mean_column(poses, count, 3, position);
    gsf__traj_mean_column(poses, count, 2, forward);
    gsf__traj_mean_column(poses, count, 1, down);
    if (gsf__traj_length(forward) < 1e-9 || gsf__traj_length(down) < 1e-9)
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "average pose: the directions of the %zu views cancel", count);
    if (official) // viewmatrix() negates the direction that average_pose() gives it
        for (int i = 0; i < 3; i++) forward[i] = -forward[i];
    if (!gsf__traj_axes(forward, down, position, pose))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "average pose: %zu views look along their mean up vector", count);
    return GSF_OK;
}

// Poses relative to their average pose; transform = inverse of that. out may be poses.
GSF__GOLDEN gsf_result gsf__traj_recenter_poses(gsf_context* ctx, const double* poses, size_t count, int32_t official,
                                                double* out, double transform[16]) {
    double average[16];
    GSF__TRY(gsf__traj_average_pose(ctx, poses, count, official, average));
    gsf__mat4_rigid_inverse(average, transform);
    for (size_t n = 0; n < count; n++) {
        double local[16];
        memcpy(local, poses + 16 * n, sizeof local);
        // Subtracted before the rotation, to keep precision far from the origin.
        for (int i = 0; i < 3; i++) local[12 + i] -= average[12 + i];
        double rotation[16];
        memcpy(rotation, transform, sizeof rotation);
        memset(rotation + 12, 0, 3 * sizeof(double));
        gsf__mat4_mul(rotation, local, out + 16 * n);
    }
    return gsf__traj_check_path(ctx, out, count);
}

// Mean camera position and the largest distance from it. The release's scene_scale is the radius of all cameras, 3DGS's
// cameras_extent is 1.1 times the radius of the training cameras.
GSF__GOLDEN gsf_result gsf__traj_camera_radius(gsf_context* ctx, const double* poses, size_t count, double center[3],
                                               double* radius) {
    GSF__TRY(gsf__traj_check_views(ctx, "camera radius", poses, count));
    gsf__traj_mean_column(poses, count, 3, center);
    *radius = 0.0;
    for (size_t n = 0; n < count; n++) {
        const double d = gsf__traj_distance(poses + 16 * n + 12, center);
        if (d > *radius) *radius = d;
    }
    return GSF_OK;
}

// Index of the view with the smallest score |position difference| + direction_weight * (1 - forward . forward); the
// lowest index among equals (to 1e-9). scores: NULL or (count). The release's weight is 0.5, in the normalised frame.
static gsf_result gsf__traj_nearest_view(gsf_context* ctx, const double pose[16], const double* poses, size_t count,
                                         double direction_weight, int32_t* index, double* scores) {
    *index = 0;
    GSF__TRY(gsf__traj_check_views(ctx, "nearest view", poses, count));
    GSF__TRY(gsf__traj_check_poses(ctx, pose, 1));
    if (!isfinite(direction_weight))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "nearest view: direction weight is %g", direction_weight);
    if (count > INT32_MAX) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "nearest view: %zu views", count);
    double best = 0.0;
    for (size_t n = 0; n < count; n++) {
        const double* view = poses + 16 * n;
        const double score = gsf__traj_distance(view + 12, pose + 12) +
                             direction_weight * (1.0 - gsf__traj_dot(view + 8, pose + 8));
        if (scores) scores[n] = score;
        if (n == 0 || score < best - 1e-9 * fabs(best)) {
            best = score;
            *index = (int32_t)n;
        }
    }
    return GSF_OK;
}

// ---- >>normalisation -----------------------------------------------------------

// The smallest rotation (row-major) that takes the unit vector u to (0,-1,0): I + [v] + [v]^2 / (1 + c) with
// v = u x (0,-1,0), c = -u_y. 1 + c is computed from |v| where it would cancel. The release uses a reflection for c = -1.
static void gsf__traj_upright(const double u[3], double r[9]) {
    const double across = u[0] * u[0] + u[2] * u[2]; // |v|^2
    if (u[1] > 0.0 && across < 1e-300) {
        const double half_turn[9] = {1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0};
        memcpy(r, half_turn, sizeof half_turn);
        return;
    }
    const double one_plus_c = u[1] > 0.0 ? across / (1.0 + u[1]) : 1.0 - u[1];
    const double v[3] = {u[2], 0.0, -u[0]};
    const double skew[9] = {0.0, -v[2], v[1], v[2], 0.0, -v[0], -v[1], v[0], 0.0};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const double square = v[i] * v[j] - (i == j ? across : 0.0); // [v]^2 = v v^T - |v|^2 I
            r[3 * i + j] = (i == j) + skew[3 * i + j] + square / one_plus_c;
        }
}

typedef enum gsf__traj_center {
    GSF_TRAJ_CENTER_FOCUS = 0, // median of the points of the optical axes nearest to the mean camera position
    GSF_TRAJ_CENTER_POSES,     // median camera position
} gsf__traj_center;

typedef struct gsf__traj_similarity_desc {
    gsf__traj_center center;
    int32_t strict_scaling; // scale so that the farthest camera is at distance 1; zero: the median camera
    int32_t official;       // FOCUS: points of the axes nearest to the world's origin
} gsf__traj_similarity_desc;

static size_t gsf__traj_similarity_scratch(size_t count) { return gsf__traj_size_mul(count, 7 * sizeof(double)); }

// magnitude: largest coordinate before the origin was subtracted; lengths below 1e-13 of it are rounding errors.
static gsf_result gsf__traj_solve_similarity(gsf_context* ctx, const double* poses, size_t count,
                                       const gsf__traj_similarity_desc* desc, double magnitude, double* work,
                                       double transform[16]) {
    double ups[3], r[9], middle[3], mean[3] = {0.0, 0.0, 0.0};
    gsf__traj_mean_column(poses, count, 1, ups);
    for (int i = 0; i < 3; i++) ups[i] = -ups[i];
    if (gsf__traj_length(ups) < 1e-9 || !gsf__traj_unit(ups, ups))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "similarity: the up vectors of the %zu views cancel", count);
    gsf__traj_upright(ups, r);
    double *t = work, *near_points = work + 3 * count, *values = work + 6 * count;
    for (size_t n = 0; n < count; n++)
        for (int i = 0; i < 3; i++) t[3 * n + (size_t)i] = gsf__traj_dot(r + 3 * i, poses + 16 * n + 12);
    if (!desc->official) {
        double world[3];
        gsf__traj_mean_column(poses, count, 3, world);
        for (int i = 0; i < 3; i++) mean[i] = gsf__traj_dot(r + 3 * i, world);
    }
    for (size_t n = 0; n < count; n++) {
        if (desc->center == GSF_TRAJ_CENTER_POSES) {
            memcpy(near_points + 3 * n, t + 3 * n, 3 * sizeof(double));
            continue;
        }
        double forward[3], away = 0.0;
        for (int i = 0; i < 3; i++) forward[i] = gsf__traj_dot(r + 3 * i, poses + 16 * n + 8);
        for (int i = 0; i < 3; i++) away += forward[i] * (mean[i] - t[3 * n + (size_t)i]);
        for (int i = 0; i < 3; i++) near_points[3 * n + (size_t)i] = t[3 * n + (size_t)i] + away * forward[i];
    }
    for (int i = 0; i < 3; i++) {
        for (size_t n = 0; n < count; n++) values[n] = near_points[3 * n + (size_t)i];
        middle[i] = gsf__traj_median(values, count);
    }
    for (size_t n = 0; n < count; n++) values[n] = gsf__traj_distance(t + 3 * n, middle);
    double size = gsf__traj_median(values, count);
    const double rounding = 1e-13 * magnitude;
    if (desc->strict_scaling || (!desc->official && !(size > rounding))) size = values[count - 1];
    if (!(size > rounding))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "similarity: the %zu cameras are all at one point", count);
    gsf__traj_identity(transform);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) transform[4 * j + i] = r[3 * i + j] / size;
        transform[12 + i] = -middle[i] / size;
    }
    return gsf__traj_check_path(ctx, transform, 1);
}

static double gsf__traj_magnitude(const double* points, size_t count, size_t stride) {
    double most = 0.0;
    for (size_t n = 0; n < count; n++) {
        const double m = gsf__traj_max_abs(points + stride * n);
        if (m > most) most = m;
    }
    return most;
}

static gsf_result gsf__traj_check_center(gsf_context* ctx, const gsf__traj_similarity_desc* desc) {
    if (desc && desc->center != GSF_TRAJ_CENTER_FOCUS && desc->center != GSF_TRAJ_CENTER_POSES)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "similarity: center is %d", (int)desc->center);
    return GSF_OK;
}

static gsf__traj_similarity_desc gsf__traj_similarity_desc_defaults(const gsf__traj_similarity_desc* desc) {
    gsf__traj_similarity_desc out;
    memset(&out, 0, sizeof out);
    if (desc) out = *desc;
    return out;
}

// T that rotates the mean camera up vector (minus column 1) to world -y, moves the centre to 0 and scales cameras to
// distance 1 (the release's similarity_from_cameras). Degenerate if up vectors cancel or all cameras are at the centre.
GSF__GOLDEN gsf_result gsf__traj_similarity(gsf_context* ctx, const double* poses, size_t count,
                                            const gsf__traj_similarity_desc* desc, void* scratch, double transform[16]) {
    GSF__TRY(gsf__traj_check_center(ctx, desc));
    GSF__TRY(gsf__traj_check_views(ctx, "similarity", poses, count));
    const gsf__traj_similarity_desc d = gsf__traj_similarity_desc_defaults(desc);
    return gsf__traj_solve_similarity(ctx, poses, count, &d, gsf__traj_magnitude(poses + 12, count, 16),
                                      (double*)scratch,
                                transform);
}

typedef struct gsf__traj_cloud { // points after subtracting the origin and transforming: T (p - origin)
    const double* points;
    size_t count, stride; // stride in doubles
    double origin[3];
    double transform[16];
    int robust; // exclude outliers
} gsf__traj_cloud;

static void gsf__traj_cloud_point(const gsf__traj_cloud* cloud, size_t n, double out[3]) {
    for (int i = 0; i < 3; i++) out[i] = cloud->points[cloud->stride * n + (size_t)i] - cloud->origin[i];
    gsf__traj_apply(cloud->transform, out, out);
}

// Distance from the median within which points are used: 5 times the 90th percentile; infinite if all are. Variances
// are not robust: 10 outliers among the 4,000 points of a structure-from-motion cloud can rotate the axes by 30
// degrees.
static double gsf__traj_cloud_reach(const gsf__traj_cloud* cloud, const double median[3], double* work) {
    if (!cloud->robust) return (double)INFINITY;
    for (size_t n = 0; n < cloud->count; n++) {
        double p[3];
        gsf__traj_cloud_point(cloud, n, p);
        work[n] = gsf__traj_distance(p, median);
    }
    gsf__traj_sort(work, cloud->count);
    const double most = gsf__traj_percentile(work, cloud->count, 0.9);
    return most > 0.0 ? 5.0 * most : (double)INFINITY;
}

// Mean (relative to the median) and covariance of the points within reach.
static void gsf__traj_cloud_moments(const gsf__traj_cloud* cloud, const double median[3], double reach, double mean[3],
                                    double covariance[9]) {
    double p[3];
    size_t count = 0;
    for (size_t n = 0; n < cloud->count; n++) {
        gsf__traj_cloud_point(cloud, n, p);
        count += !(gsf__traj_distance(p, median) > reach);
    }
    memset(mean, 0, 3 * sizeof(double));
    memset(covariance, 0, 9 * sizeof(double));
    for (int pass = 0; pass < 2; pass++)
        for (size_t n = 0; n < cloud->count; n++) {
            gsf__traj_cloud_point(cloud, n, p);
            if (gsf__traj_distance(p, median) > reach) continue;
            for (int i = 0; i < 3 && pass == 0; i++) mean[i] += (p[i] - median[i]) / (double)count;
            for (int i = 0; i < 3; i++) p[i] -= median[i] + mean[i];
            for (int i = 0; i < 9 && pass == 1; i++) covariance[i] += p[i / 3] * p[i % 3] / (double)count;
        }
}

// up: NULL, or the vector that determines the third axis if the points are collinear.
static gsf_result gsf__traj_cloud_axes(gsf_context* ctx, const gsf__traj_cloud* cloud, const double* up, double* work,
                                       double transform[16]) {
    double median[3], mean[3], covariance[9], values[3], rows[9], p[3];
    if (cloud->count == 0) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "principal axes: no point");
    for (int i = 0; i < 3; i++) {
        for (size_t n = 0; n < cloud->count; n++) {
            gsf__traj_cloud_point(cloud, n, p);
            if (!gsf__traj_finite(p, 3))
                return gsf_fail(ctx, GSF_ERROR_NUMERIC, "principal axes: point %zu is not finite", n);
            work[n] = p[i];
        }
        median[i] = gsf__traj_median(work, cloud->count);
    }
    gsf__traj_cloud_moments(cloud, median, gsf__traj_cloud_reach(cloud, median, work), mean, covariance);
    if (!gsf__traj_finite(covariance, 9))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "principal axes: coordinates are too large");
    gsf__mat3_eigen(covariance, values, rows);
    const double rounding = 1e-13 * gsf__traj_max_abs(median);
    if (!(sqrt(values[0] > 0.0 ? values[0] : 0.0) > rounding) || !(values[0] > 0.0))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "principal axes: the %zu points coincide", cloud->count);
    if (values[1] <= 1e-14 * values[0]) {
        if (!up || fabs(gsf__traj_dot(up, rows)) > 1.0 - 1e-9)
            return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "principal axes: the %zu points lie on a line", cloud->count);
        const double along = gsf__traj_dot(up, rows);
        for (int i = 0; i < 3; i++) rows[6 + i] = up[i] - along * rows[i];
        (void)gsf__traj_unit(rows + 6, rows + 6);
        gsf__traj_cross(rows + 6, rows, rows + 3);
        values[1] = 0.5 * values[0]; // so that gsf__traj_fix_axes finds no equal eigenvalues
        values[2] = 0.0;
    }
    gsf__traj_fix_axes(values, rows);
    gsf__traj_identity(transform);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) transform[4 * j + i] = rows[3 * i + j];
        transform[12 + i] = -gsf__traj_dot(rows + 3 * i, median);
    }
    return GSF_OK;
}

static void gsf__traj_cloud_init(gsf__traj_cloud* cloud, const double* points, size_t count, size_t stride) {
    memset(cloud, 0, sizeof *cloud);
    cloud->points = points;
    cloud->count = count;
    cloud->stride = stride;
    gsf__traj_identity(cloud->transform);
}

static size_t gsf__traj_principal_axes_scratch(size_t count) { return gsf__traj_size_mul(count, sizeof(double)); }

// Rigid T that moves the points' median to 0 and their principal axes to x, y, z by descending variance (the release's
// align_principle_axes). Signs of the eigenvectors: the largest component of rows 0 and 1 is positive, the determinant is
// +1. points (count,3). Degenerate for coincident and collinear points.
GSF__GOLDEN gsf_result gsf__traj_principal_axes(gsf_context* ctx, const double* points, size_t count, void* scratch,
                                                double transform[16]) {
    gsf__traj_cloud cloud;
    gsf__traj_cloud_init(&cloud, points, points ? count : 0, 3);
    return gsf__traj_cloud_axes(ctx, &cloud, NULL, (double*)scratch, transform);
}

static size_t gsf__traj_normalize_scratch(size_t count, size_t point_count) {
    return gsf__traj_size_max(gsf__traj_similarity_scratch(count), gsf__traj_principal_axes_scratch(point_count));
}

// Like gsf__traj_normalize; poses are relative to `origin`, points are not.
static gsf_result gsf__traj_solve_frame(gsf_context* ctx, const double* poses, size_t count, const double* points,
                                      size_t point_count, const double origin[3], double magnitude,
                                      const gsf__traj_similarity_desc* desc, double* work, double transform[16]) {
    static const double up[3] = {0.0, -1.0, 0.0}; // the similarity rotates the mean up vector to this
    double first[16], second[16];
    GSF__TRY(gsf__traj_solve_similarity(ctx, poses, count, desc, magnitude, work, first));
    gsf__traj_cloud cloud;
    if (points && point_count) {
        gsf__traj_cloud_init(&cloud, points, point_count, 3);
        memcpy(cloud.origin, origin, 3 * sizeof(double));
        cloud.robust = !desc->official;
    } else {
        gsf__traj_cloud_init(&cloud, poses + 12, count, 16);
    }
    memcpy(cloud.transform, first, sizeof first);
    GSF__TRY(gsf__traj_cloud_axes(ctx, &cloud, points && point_count ? NULL : up, work, second));
    gsf__mat4_mul(second, first, transform);
    return gsf__traj_check_path(ctx, transform, 1);
}

// Similarity, then principal axes of the points (NULL: of the camera positions; where these lie on a line, the mean up
// vector determines the third axis). `transform` is the product, as in the release's parser. Points farther from the
// median than five times the 90th percentile of distances are excluded (official: none).
GSF__GOLDEN gsf_result gsf__traj_normalize(gsf_context* ctx, const double* poses, size_t count, const double* points,
                                           size_t point_count, const gsf__traj_similarity_desc* desc, void* scratch,
                                           double transform[16]) {
    static const double origin[3] = {0.0, 0.0, 0.0};
    GSF__TRY(gsf__traj_check_center(ctx, desc));
    GSF__TRY(gsf__traj_check_views(ctx, "normalisation", poses, count));
    const gsf__traj_similarity_desc d = gsf__traj_similarity_desc_defaults(desc);
    return gsf__traj_solve_frame(ctx, poses, count, points, point_count, origin,
                               gsf__traj_magnitude(poses + 12, count, 16), &d, (double*)scratch, transform);
}

// Applies a similarity and keeps rotations orthonormal. out may be the input.
static void gsf__traj_transform_poses(const double transform[16], const double* poses, size_t count, double* out) {
    double rotation[16];
    const double row[3] = {transform[0], transform[4], transform[8]};
    const double scale = gsf__traj_length(row);
    gsf__traj_identity(rotation);
    for (int c = 0; c < 3; c++)
        for (int r = 0; r < 3; r++) rotation[4 * c + r] = transform[4 * c + r] / scale;
    for (size_t n = 0; n < count; n++) {
        double position[3];
        gsf__traj_apply(transform, poses + 16 * n + 12, position);
        gsf__mat4_mul(rotation, poses + 16 * n, out + 16 * n);
        memcpy(out + 16 * n + 12, position, sizeof position);
    }
}

// Principal axes of the positions about their mean, y down on average, largest coordinate 1 (the release's
// transform_poses_pca; the same sign rule). out may be poses.
GSF__GOLDEN gsf_result gsf__traj_pca_poses(gsf_context* ctx, const double* poses, size_t count, double* out,
                                           double transform[16]) {
    GSF__TRY(gsf__traj_check_views(ctx, "principal axes", poses, count));
    double mean[3], scatter[9], values[3], rows[9], y_axis[3];
    gsf__traj_mean_column(poses, count, 3, mean);
    memset(scatter, 0, sizeof scatter);
    for (size_t n = 0; n < count; n++) {
        const double* p = poses + 16 * n + 12;
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) scatter[3 * i + j] += (p[i] - mean[i]) * (p[j] - mean[j]);
    }
    if (!gsf__traj_finite(scatter, 9))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "principal axes: coordinates are too large");
    gsf__mat3_eigen(scatter, values, rows);
    const double rounding = 1e-13 * gsf__traj_magnitude(poses + 12, count, 16);
    if (!(values[0] > rounding * rounding) || values[1] <= 1e-14 * values[0])
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "principal axes: the %zu cameras lie on a line or a point", count);
    gsf__traj_fix_axes(values, rows);
    gsf__traj_mean_column(poses, count, 1, y_axis);
    if (gsf__traj_dot(rows + 6, y_axis) < 0.0)
        for (int i = 3; i < 9; i++) rows[i] = -rows[i];
    double most = 0.0;
    for (size_t n = 0; n < count; n++) {
        const double* p = poses + 16 * n + 12;
        const double d[3] = {p[0] - mean[0], p[1] - mean[1], p[2] - mean[2]};
        for (int i = 0; i < 3; i++) {
            const double c = fabs(gsf__traj_dot(rows + 3 * i, d));
            if (c > most) most = c;
        }
    }
    gsf__traj_identity(transform);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) transform[4 * j + i] = rows[3 * i + j] / most;
        transform[12 + i] = -gsf__traj_dot(rows + 3 * i, mean) / most;
    }
    GSF__TRY(gsf__traj_check_path(ctx, transform, 1));
    gsf__traj_transform_poses(transform, poses, count, out);
    return GSF_OK;
}

static gsf_result gsf__traj_check_similarity(gsf_context* ctx, const double t[16]) {
    if (!gsf__traj_finite(t, 16)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "similarity: a value is not finite");
    const double scale = gsf__traj_length(t);
    if (!(scale > 0.0)) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "similarity: its scale is zero");
    double c[3][3], z[3];
    for (int a = 0; a < 3; a++)
        for (int i = 0; i < 3; i++) c[a][i] = t[4 * a + i] / scale;
    for (int a = 0; a < 3; a++)
        for (int b = a; b < 3; b++)
            if (!(fabs(gsf__traj_dot(c[a], c[b]) - (a == b)) <= 1e-6))
                return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "similarity: not a rotation (columns %d, %d)", a, b);
    gsf__traj_cross(c[0], c[1], z);
    if (!(gsf__traj_dot(z, c[2]) > 0.0)) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "similarity: a reflection");
    if (t[3] != 0.0 || t[7] != 0.0 || t[11] != 0.0 || fabs(t[15] - 1.0) > 1e-12)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "similarity: last row is not 0 0 0 1");
    return GSF_OK;
}

// Inverse of a similarity; fails if the matrix is not one.
static gsf_result gsf__traj_invert_similarity(gsf_context* ctx, const double transform[16], double out[16]) {
    GSF__TRY(gsf__traj_check_similarity(ctx, transform));
    const double scale = gsf__traj_length(transform);
    double rotation[9], inverse[16]; // rotation row-major
    gsf__traj_identity(inverse);
    for (int c = 0; c < 3; c++)
        for (int r = 0; r < 3; r++) rotation[3 * r + c] = transform[4 * c + r] / scale;
    for (int c = 0; c < 3; c++)
        for (int r = 0; r < 3; r++) inverse[4 * c + r] = rotation[3 * c + r] / scale;
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) inverse[12 + r] -= inverse[4 * c + r] * transform[12 + c];
    GSF__TRY(gsf__traj_check_path(ctx, inverse, 1));
    memcpy(out, inverse, sizeof inverse);
    return GSF_OK;
}

// ---- >>splines -----------------------------------------------------------------

enum { GSF__TRAJ_DEGREE_MAX = 5 };

typedef struct gsf__traj_curve { // views into scratch
    size_t count, dims;
    int degree;
    double* knots;        // (count + degree + 1)
    double* coefficients; // (count,dims)
    double* band;         // (count, 2 degree + 1), needed only while the spline is made
} gsf__traj_curve;

static size_t gsf__traj_curve_doubles(size_t count, int degree, size_t dims) {
    const size_t k = (size_t)degree;
    return gsf__traj_size_add(gsf__traj_size_mul(count, gsf__traj_size_add(dims, 2 * k + 2)), k + 1);
}

// The knot span of u and the degree + 1 basis functions that are non-zero on it (de Boor's recurrence, algorithm A2.2
// of The NURBS Book).
static size_t gsf__traj_basis(const gsf__traj_curve* curve, double u, double basis[GSF__TRAJ_DEGREE_MAX + 1]) {
    const size_t k = (size_t)curve->degree;
    size_t low = k, high = curve->count; // knots[low] <= u < knots[high], or the last span
    while (high - low > 1) {
        const size_t mid = low + (high - low) / 2;
        if (u < curve->knots[mid]) high = mid;
        else low = mid;
    }
    double left[GSF__TRAJ_DEGREE_MAX + 1], right[GSF__TRAJ_DEGREE_MAX + 1];
    basis[0] = 1.0;
    for (size_t j = 1; j <= k; j++) {
        left[j] = u - curve->knots[low + 1 - j];
        right[j] = curve->knots[low + j] - u;
        double saved = 0.0;
        for (size_t r = 0; r < j; r++) {
            const double part = basis[r] / (right[r + 1] + left[j - r]);
            basis[r] = saved + right[r + 1] * part;
            saved = left[j - r] * part;
        }
        basis[j] = saved;
    }
    return low - k; // index of the first basis function
}

// Makes the B-spline of `degree` (at most count - 1) through values[i] (stride doubles apart) at sites, with not-a-knot
// ends (knots as in FITPACK with s = 0 and scipy's make_interp_spline). Collocation matrices of B-splines are totally
// positive, so elimination within the band needs no pivoting. Returns 0 if sites are not strictly ascending.
static int gsf__traj_make_curve(gsf__traj_curve* curve, const double* sites, const double* values, size_t stride,
                                size_t count, size_t dims, int degree, double* work) {
    const size_t k = (size_t)degree, width = 2 * k + 1;
    curve->count = count;
    curve->dims = dims;
    curve->degree = degree;
    curve->knots = work;
    curve->coefficients = curve->knots + count + k + 1;
    curve->band = curve->coefficients + count * dims;
    for (size_t i = 1; i < count; i++)
        if (!(sites[i] > sites[i - 1])) return 0;
    for (size_t i = 0; i <= k; i++) {
        curve->knots[i] = sites[0];
        curve->knots[count + i] = sites[count - 1];
    }
    for (size_t i = 0; i + k + 1 < count; i++) // not-a-knot: sites for odd degrees, their midpoints for even ones
        curve->knots[k + 1 + i] = k % 2 ? sites[i + (k + 1) / 2] : 0.5 * (sites[i + k / 2] + sites[i + k / 2 + 1]);
    memset(curve->band, 0, count * width * sizeof(double));
    for (size_t i = 0; i < count; i++) { // band[i][j] is the matrix's column i + j - k
        double basis[GSF__TRAJ_DEGREE_MAX + 1];
        const size_t first = gsf__traj_basis(curve, sites[i], basis);
        for (size_t j = 0; j <= k; j++)
            if (first + j + k >= i && first + j <= i + k) curve->band[i * width + first + j + k - i] = basis[j];
        for (size_t d = 0; d < dims; d++) curve->coefficients[i * dims + d] = values[i * stride + d];
    }
    for (size_t i = 0; i < count; i++) {
        const double pivot = curve->band[i * width + k];
        if (!(pivot > 0.0)) return 0;
        for (size_t r = i + 1; r < count && r <= i + k; r++) {
            const double factor = curve->band[r * width + i + k - r] / pivot;
            if (factor == 0.0) continue;
            for (size_t j = 1; j <= k && i + j < count; j++)
                curve->band[r * width + i + j + k - r] -= factor * curve->band[i * width + j + k];
            for (size_t d = 0; d < dims; d++)
                curve->coefficients[r * dims + d] -= factor * curve->coefficients[i * dims + d];
        }
    }
    for (size_t i = count; i-- > 0;)
        for (size_t d = 0; d < dims; d++) {
            double sum = curve->coefficients[i * dims + d];
            for (size_t j = 1; j <= k && i + j < count; j++)
                sum -= curve->band[i * width + j + k] * curve->coefficients[(i + j) * dims + d];
            curve->coefficients[i * dims + d] = sum / curve->band[i * width + k];
        }
    return 1;
}

// Evaluates the curve at u, clamped to the range of the sites.
static void gsf__traj_eval_curve(const gsf__traj_curve* curve, double u, double* out) {
    double basis[GSF__TRAJ_DEGREE_MAX + 1];
    const double first_site = curve->knots[0], last_site = curve->knots[curve->count];
    const size_t first = gsf__traj_basis(curve, u < first_site ? first_site : u > last_site ? last_site : u, basis);
    for (size_t d = 0; d < curve->dims; d++) {
        double sum = 0.0;
        for (size_t j = 0; j <= (size_t)curve->degree; j++)
            sum += basis[j] * curve->coefficients[(first + j) * curve->dims + d];
        out[d] = sum;
    }
}

typedef struct gsf__traj_spline_desc {
    int32_t frames_per_leg; // 0 = 16
    int32_t degree;         // 0 = 5; at most count - 1 is used
    double axis_length;     // distance of the look-at and up points from the position; 0 = 0.1
} gsf__traj_spline_desc;

static gsf__traj_spline_desc gsf__traj_spline_desc_defaults(const gsf__traj_spline_desc* desc, size_t count) {
    gsf__traj_spline_desc out;
    memset(&out, 0, sizeof out);
    if (desc) out = *desc;
    if (out.frames_per_leg == 0) out.frames_per_leg = 16;
    if (out.degree == 0) out.degree = GSF__TRAJ_DEGREE_MAX;
    if (count >= 2 && (size_t)(out.degree < 1 ? 1 : out.degree) > count - 1) out.degree = (int32_t)(count - 1);
    if (out.axis_length == 0.0) out.axis_length = 0.1;
    return out;
}

static gsf_result gsf__traj_check_spline(gsf_context* ctx, const gsf__traj_spline_desc* d) {
    if (d->frames_per_leg < 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "spline path: %d frames per leg", (int)d->frames_per_leg);
    if (d->degree < 1 || d->degree > GSF__TRAJ_DEGREE_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "spline path: degree %d is not 1..5", (int)d->degree);
    if (!isfinite(d->axis_length))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "spline path: axis length %g", d->axis_length);
    if (!(d->axis_length > 0.0))
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "spline path: axis length %g", d->axis_length);
    return GSF_OK;
}

GSF__GOLDEN size_t gsf__traj_spline_path_scratch(size_t count, const gsf__traj_spline_desc* desc) {
    const gsf__traj_spline_desc d = gsf__traj_spline_desc_defaults(desc, count);
    if (d.degree < 1 || d.degree > GSF__TRAJ_DEGREE_MAX) return SIZE_MAX;
    const size_t rows = gsf__traj_size_mul(count, 10); // 9 coordinates and the site of each pose
    return gsf__traj_size_mul(gsf__traj_size_add(rows, gsf__traj_curve_doubles(count, d.degree, 9)), sizeof(double));
}

// Spline through (position, position - arm * forward, position + arm * down) of the poses, by chord length;
// frames_per_leg * (count - 1) poses, the last one excluded (the release's generate_interpolated_path with smoothness
// 0; for two poses, with any smoothness). Degenerate if neighbouring poses coincide or directions cancel.
GSF__GOLDEN gsf_result gsf__traj_spline_path(gsf_context* ctx, const double* poses, size_t count,
                                             const gsf__traj_spline_desc* desc, void* scratch, double* out) {
    const gsf__traj_spline_desc d = gsf__traj_spline_desc_defaults(desc, count);
    GSF__TRY(gsf__traj_check_spline(ctx, &d));
    GSF__TRY(gsf__traj_check_views(ctx, "spline path", poses, count));
    if (count < 2) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "spline path: one view");
    double *points = (double*)scratch, *sites = points + 9 * count;
    const double* origin = poses + 12;
    sites[0] = 0.0;
    for (size_t n = 0; n < count; n++) { // (position, position - arm * forward, position + arm * down)
        const double* m = poses + 16 * n;
        double* p = points + 9 * n;
        double square = 0.0;
        for (int i = 0; i < 3; i++) {
            p[i] = m[12 + i] - origin[i];
            p[3 + i] = p[i] - d.axis_length * m[8 + i];
            p[6 + i] = p[i] + d.axis_length * m[4 + i];
        }
        if (n == 0) continue;
        for (int i = 0; i < 9; i++) square += (p[i] - p[i - 9]) * (p[i] - p[i - 9]);
        sites[n] = sites[n - 1] + sqrt(square);
    }
    if (!isfinite(sites[count - 1])) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "spline path: coordinates are too large");
    for (size_t n = 1; n < count; n++)
        if (!(sites[n] - sites[n - 1] > 1e-12 * sites[count - 1]))
            return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "spline path: poses %zu and %zu coincide", n - 1, n);
    for (size_t n = 1; n < count; n++) sites[n] /= sites[count - 1];
    gsf__traj_curve curve;
    if (!gsf__traj_make_curve(&curve, sites, points, 9, count, 9, (int)d.degree, sites + count))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "spline path: distances of poses differ too much");
    const size_t frames = (count - 1) * (size_t)d.frames_per_leg;
    for (size_t f = 0; f < frames; f++) {
        double p[9], forward[3], down[3];
        gsf__traj_eval_curve(&curve, (double)f / (double)frames, p);
        for (int i = 0; i < 3; i++) {
            forward[i] = p[i] - p[3 + i];
            down[i] = p[6 + i] - p[i];
            p[i] += origin[i];
        }
        if (gsf__traj_length(forward) < 1e-9 * d.axis_length || !gsf__traj_axes(forward, down, p, out + 16 * f)) {
            memset(out, 0, 16 * frames * sizeof(double));
            return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "spline path: directions cancel at frame %zu", f);
        }
    }
    return gsf__traj_check_path(ctx, out, frames);
}

static size_t gsf__traj_slerp_path_scratch(size_t count) {
    const int degree = count < 3 ? 1 : count < 4 ? 2 : 3;
    const size_t rows = gsf__traj_size_mul(count, 4); // site and position of each pose
    return gsf__traj_size_mul(gsf__traj_size_add(rows, gsf__traj_curve_doubles(count, degree, 3)), sizeof(double));
}

// A path through poses at evenly spaced sites, positions relative to the first pose: splines of degree 1, 2, 3 for 2,
// 3, more poses.
static int gsf__traj_make_glide(gsf__traj_curve* curve, const double* poses, size_t count, double* work) {
    double *sites = work, *positions = work + count;
    for (size_t n = 0; n < count; n++) {
        sites[n] = (double)n;
        for (int i = 0; i < 3; i++) positions[3 * n + (size_t)i] = poses[16 * n + 12 + (size_t)i] - poses[12 + i];
    }
    return gsf__traj_make_curve(curve, sites, positions, 3, count, 3, count < 3 ? 1 : count < 4 ? 2 : 3,
                                positions + 3 * count);
}

// The pose at u in [0, count - 1]: poses are at integer u.
static void gsf__traj_eval_glide(const gsf__traj_curve* curve, const double* poses, size_t count, double u,
                                 double out[16]) {
    size_t leg = (size_t)u;
    if (leg > count - 2) leg = count - 2;
    double position[3];
    gsf__traj_eval_curve(curve, u, position);
    gsf__traj_blend_poses(poses + 16 * leg, poses + 16 * (leg + 1), u - (double)leg, out);
    for (int i = 0; i < 3; i++) out[12 + i] = poses[12 + i] + position[i];
}

// Positions by a spline over evenly spaced sites (degree 1, 2, 3 for 2, 3, more views), rotations by slerp, then each
// pose moved by `push` along its forward axis (the release's interpolate_camera_path, which draws push from [0, 0.5)).
// `frames` poses (>= 1), both ends included.
GSF__GOLDEN gsf_result gsf__traj_slerp_path(gsf_context* ctx, const double* poses, size_t count, int32_t frames,
                                            double push, void* scratch, double* out) {
    GSF__TRY(gsf__traj_check_views(ctx, "slerp path", poses, count));
    if (count < 2) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "slerp path: one view");
    if (frames < 1) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "slerp path: %d frames", (int)frames);
    if (!isfinite(push)) return gsf_fail(ctx, GSF_ERROR_NUMERIC, "slerp path: push is %g", push);
    gsf__traj_curve curve;
    if (!gsf__traj_make_glide(&curve, poses, count, (double*)scratch))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "slerp path: no spline through %zu poses", count);
    for (int32_t f = 0; f < frames; f++) {
        double* pose = out + 16 * (size_t)f;
        const double u = frames == 1 ? 0.0 : (double)f * (double)(count - 1) / (double)(frames - 1);
        gsf__traj_eval_glide(&curve, poses, count, u, pose);
        for (int i = 0; i < 3; i++) pose[12 + i] += push * pose[8 + i];
    }
    return gsf__traj_check_path(ctx, out, (size_t)frames);
}

// ---- >>ellipse -----------------------------------------------------------------

// The release's parameters of an outpaint round: z_variation max(0.5, 1.5 - 0.2 round), pitch 2 degrees * round, a random
// z_phase (from seed and round). frames 0 = 85.
static gsf_traj_ellipse_desc gsf__traj_round_ellipse(int32_t round, uint64_t seed, int32_t frames) {
    gsf_traj_ellipse_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.frames = frames;
    desc.z_variation = 1.5 - 0.2 * round;
    if (desc.z_variation < 0.5) desc.z_variation = 0.5;
    desc.z_phase = gsf_draw_uniform(seed, 0x74726a00u, (uint64_t)(uint32_t)round); // in a separate random stream
    desc.pitch_degrees = 2.0 * round;
    return desc;
}

static gsf_traj_ellipse_desc gsf__traj_ellipse_desc_defaults(const gsf_traj_ellipse_desc* desc) {
    gsf_traj_ellipse_desc out;
    memset(&out, 0, sizeof out);
    if (desc) out = *desc;
    if (out.frames == 0) out.frames = 85;
    return out;
}

static gsf_result gsf__traj_check_ellipse(gsf_context* ctx, const gsf_traj_ellipse_desc* d) {
    if (d->frames < 1) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "ellipse: %d frames", (int)d->frames);
    if (!isfinite(d->z_variation) || !isfinite(d->z_phase) || !isfinite(d->pitch_degrees))
        return gsf_fail(ctx, GSF_ERROR_NUMERIC, "ellipse: a parameter is not finite");
    return GSF_OK;
}

static size_t gsf__traj_ellipse_scratch(size_t count) { return gsf__traj_size_mul(count, sizeof(double)); }

// generate_ellipse_path of outpaint/sample_utils.py (after multinerf), without its random sign, which is never used.
static gsf_result gsf__traj_ellipse(gsf_context* ctx, const double* poses, size_t count, const gsf_traj_ellipse_desc* desc,
                                    const double focus[3], double* work, double* out) {
    const double two_pi = 6.283185307179586476925286766559;
    const gsf_traj_ellipse_desc d = *desc;
    double down[3], low[2], high[2];
    for (int i = 0; i < 2; i++) {
        for (size_t n = 0; n < count; n++) work[n] = fabs(poses[16 * n + 12 + (size_t)i] - focus[i]);
        gsf__traj_sort(work, count);
        const double half_axis = gsf__traj_percentile(work, count, 0.9);
        low[i] = (focus[i] - half_axis) * 1.2; // as in the release, this also scales the focus
        high[i] = (focus[i] + half_axis) * 1.2;
    }
    for (size_t n = 0; n < count; n++) work[n] = poses[16 * n + 14];
    gsf__traj_sort(work, count);
    const double z_low = gsf__traj_percentile(work, count, 0.1), z_high = gsf__traj_percentile(work, count, 0.9);
    gsf__traj_mean_column(poses, count, 1, down);
    const double most = gsf__traj_max_abs(down) * (1.0 - 1e-9);
    if (!(gsf__traj_length(down) > 1e-9))
        return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "ellipse: the up vectors of the %zu views cancel", count);
    const int axis = fabs(down[0]) >= most ? 0 : fabs(down[1]) >= most ? 1 : 2;
    for (int i = 0; i < 3; i++) down[i] = i != axis ? 0.0 : down[i] < 0.0 ? -1.0 : 1.0;
    const double pitch = d.pitch_degrees * (two_pi / 360.0), c = gsf__cos_f64(pitch), s = gsf__sin_f64(pitch);
    for (int32_t f = 0; f < d.frames; f++) {
        double* pose = out + 16 * (size_t)f;
        const double theta = two_pi * f / d.frames;
        const double position[3] = {
            low[0] + (high[0] - low[0]) * (gsf__cos_f64(theta) * 0.5 + 0.5),
            low[1] + (high[1] - low[1]) * (gsf__sin_f64(theta) * 0.5 + 0.5),
            d.z_variation * (z_low + (z_high - z_low) * (gsf__cos_f64(theta + two_pi * d.z_phase) * 0.5 + 0.5))};
        const double forward[3] = {focus[0] - position[0], focus[1] - position[1], focus[2] - position[2]};
        const double rounding = 1e-12 * (gsf__traj_max_abs(focus) + gsf__traj_max_abs(position));
        if (!(gsf__traj_length(forward) > rounding) || !gsf__traj_axes(forward, down, position, pose)) {
            memset(out, 0, 16 * (size_t)d.frames * sizeof(double));
            return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "ellipse: view %d of %d looks along its up vector", (int)f,
                            (int)d.frames);
        }
        for (int i = 0; i < 3; i++) { // multiply by [1 0 0; 0 c -s; 0 s c]
            const double y = pose[4 + i], z = pose[8 + i];
            pose[4 + i] = c * y + s * z;
            pose[8 + i] = c * z - s * y;
        }
    }
    return gsf__traj_check_path(ctx, out, (size_t)d.frames);
}

// Closed loop in the xy plane about the focus point of the poses, which must be normalised. Half axes are 1.2 times the
// 90th percentile of |position - focus|; views look at the focus; down is the coordinate axis nearest to the mean
// column 1.
GSF__GOLDEN gsf_result gsf__traj_ellipse_path(gsf_context* ctx, const double* poses, size_t count,
                                              const gsf_traj_ellipse_desc* desc, void* scratch, double* out) {
    const gsf_traj_ellipse_desc d = gsf__traj_ellipse_desc_defaults(desc);
    double focus[3];
    GSF__TRY(gsf__traj_check_ellipse(ctx, &d));
    GSF__TRY(gsf_traj_find_focus(ctx, poses, count, focus));
    return gsf__traj_ellipse(ctx, poses, count, &d, focus, (double*)scratch, out);
}

// ---- >>windows -----------------------------------------------------------------

// Frames of one window: `side` from the first reference to the ellipse, `middle` on it, `side` to the last reference.
// middle + 2 side = window_length; 49 gives 16 and 17. Needs window_length >= 2.
static void gsf__traj_split_window(int32_t window_length, int32_t* side, int32_t* middle) {
    *side = window_length < 2 ? 0 : window_length / 3 + (window_length % 3 == 2);
    *middle = window_length - 2 * *side;
}

// Windows of `middle` poses. A window shares `each` poses with the previous one, the final window `last` poses.
typedef struct gsf__traj_table { int64_t middle, windows, each, last; } gsf__traj_table;

// generate_overlapping_indices of outpaint/base.py; total >= middle >= 1.
static gsf__traj_table gsf__traj_make_table(int64_t total, int64_t middle) {
    gsf__traj_table table;
    table.middle = middle;
    table.windows = total / middle + 2;
    int64_t shared = table.windows * middle - total;
    if (shared < table.windows) shared += table.windows;
    table.each = shared / (table.windows - 1);
    table.last = shared - table.each * (table.windows - 2);
    return table;
}

static int64_t gsf__traj_table_start(gsf__traj_table table, int64_t w) {
    return w < table.windows - 1 ? w * (table.middle - table.each)
                                 : (w - 1) * (table.middle - table.each) + table.middle - table.last;
}

// The release's table of overlapping windows of `middle` poses over a sequence of `total`: starts and overlaps (count each;
// NULL: not needed). Fails if the table exceeds the sequence (usually total < middle).
static gsf_result gsf__traj_official_windows(gsf_context* ctx, int32_t total, int32_t middle, int32_t* starts,
                                                  int32_t* overlaps, int32_t* count) {
    *count = 0;
    if (middle < 1 || total < middle)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "windows: no window of %d in %d poses", (int)middle,
                        (int)total);
    const gsf__traj_table table = gsf__traj_make_table(total, middle);
    const int64_t last_start = gsf__traj_table_start(table, table.windows - 1);
    if (table.each > middle || last_start < 0 || last_start + middle > total || table.windows > INT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "windows: the release's table of %d in %d poses exceeds them",
                        (int)middle, (int)total);
    for (int64_t w = 0; w < table.windows; w++) {
        if (starts) starts[w] = (int32_t)gsf__traj_table_start(table, w);
        if (overlaps) overlaps[w] = (int32_t)(w == 0 ? 0 : w == table.windows - 1 ? table.last : table.each);
    }
    *count = (int32_t)table.windows;
    return GSF_OK;
}

// ---- >>legs --------------------------------------------------------------------

// The release's interpolation of two poses: forward and down linear, then orthonormalised. Returns 0 if they cancel.
static int gsf__traj_blend_axes(const double a[16], const double b[16], double t, double out[16]) {
    double forward[3], down[3], position[3];
    for (int i = 0; i < 3; i++) {
        forward[i] = a[8 + i] + (b[8 + i] - a[8 + i]) * t;
        down[i] = a[4 + i] + (b[4 + i] - a[4 + i]) * t;
        position[i] = a[12 + i] + (b[12 + i] - a[12 + i]) * t;
    }
    return gsf__traj_length(forward) > 1e-9 && gsf__traj_axes(forward, down, position, out);
}

// From pose to pose with linear positions: (count - 1) * (frames_per_leg - 1) + 1 poses, both ends included (the
// release's interp_traj). official: its spacing u = 0, 1/n .. (n-2)/n of each leg, n = frames_per_leg >= 2, and its
// interpolation of axes with arm 0.1; zero: even spacing and slerp.
GSF__GOLDEN gsf_result gsf__traj_leg_path(gsf_context* ctx, const double* poses, size_t count, int32_t frames_per_leg,
                                          int32_t official, double* out) {
    GSF__TRY(gsf__traj_check_views(ctx, "leg path", poses, count));
    if (count < 2) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "leg path: one view");
    if (frames_per_leg < 2)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "leg path: %d frames per leg", (int)frames_per_leg);
    const size_t steps = (size_t)frames_per_leg - 1;
    for (size_t leg = 0; leg + 1 < count; leg++) {
        const double *a = poses + 16 * leg, *b = a + 16;
        if (official && memcmp(a, b, 16 * sizeof(double)) == 0)
            return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "leg path: poses %zu and %zu coincide", leg, leg + 1);
        for (size_t i = 0; i < steps; i++) {
            double* pose = out + 16 * (leg * steps + i);
            if (!official) {
                gsf__traj_blend_poses(a, b, (double)i / (double)steps, pose);
            } else if (!gsf__traj_blend_axes(a, b, (double)i / (double)frames_per_leg, pose)) {
                memset(out, 0, 16 * (steps * (count - 1) + 1) * sizeof(double));
                return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "leg path: directions of poses %zu and %zu cancel", leg,
                                leg + 1);
            }
        }
    }
    memcpy(out + 16 * steps * (count - 1), poses + 16 * (count - 1), 16 * sizeof(double));
    return gsf__traj_check_path(ctx, out, steps * (count - 1) + 1);
}

// ---- >>schedule ----------------------------------------------------------------

GSF_API double gsf_traj_query_generative_weight(int64_t iteration, int64_t start, int64_t until, double lambda,
                                                int32_t official) {
    if (iteration >= until) return official ? 0.0 : lambda;
    if (iteration <= start) return 0.0;
    const double pi = 3.1415926535897932384626433832795;
    const double progress = ((double)iteration - (double)start) / ((double)until - (double)start);
    if (official) return lambda * gsf__sin_f64(progress * pi);
    const float t = (float)progress;
    return (double)((float)lambda * (t * (2.0f - t)));
}

GSF_API int32_t gsf_traj_query_repair_round(int32_t first, int32_t last, int32_t count, int32_t round) {
    return count > 1 ? first + (int32_t)(((int64_t)last - first) * round / (count - 1)) : first;
}

// ---- >>paths -------------------------------------------------------------------

enum { GSF__TRAJ_ELLIPSE_DEFAULT = 85, GSF__TRAJ_WINDOW_DEFAULT = 49, GSF__TRAJ_WINDOWS_DEFAULT = 7 };

static int64_t gsf__traj_or(int64_t value, int64_t if_zero) { return value ? value : if_zero; }

// Resolves lengths and counts of the release's reference path: n + (n + 1) + n frames, windows by its table.
static gsf_result gsf__traj_resolve_official(gsf_context* ctx, const gsf_traj_path_desc* d, gsf_traj_path_info* out) {
    const int32_t length = (int32_t)gsf__traj_or(d->window_length, GSF__TRAJ_WINDOW_DEFAULT);
    const int32_t poses = (int32_t)gsf__traj_or(d->ellipse_poses, GSF__TRAJ_ELLIPSE_DEFAULT);
    if (length < 7 || length % 3 != 1)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "path: the release's windows have 3n + 1 frames, at least 7, not %d", (int)length);
    int32_t windows;
    GSF__TRY(gsf__traj_official_windows(ctx, poses, length / 3 + 1, NULL, NULL, &windows));
    if (d->window_count && d->window_count != windows)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: the release's table has %d windows here, not %d",
                        (int)windows, (int)d->window_count);
    if ((int64_t)windows * length > INT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: %d windows of %d frames are too many", (int)windows,
                        (int)length);
    out->window_length = length;
    out->window_count = windows;
    out->ellipse_poses = poses;
    return GSF_OK;
}

static gsf_result gsf__traj_resolve_path(gsf_context* ctx, size_t cameras, const gsf_traj_path_desc* d,
                                         gsf_traj_path_info* out) {
    if (d->kind == GSF_TRAJ_REFERENCE && d->official) return gsf__traj_resolve_official(ctx, d, out);
    const int64_t length = gsf__traj_or(d->window_length, GSF__TRAJ_WINDOW_DEFAULT);
    const int64_t legs = cameras > 1 ? (int64_t)cameras - 1 : 1;
    const int64_t windows =
        gsf__traj_or(d->window_count, d->kind == GSF_TRAJ_INTERPOLATE ? legs : (int64_t)GSF__TRAJ_WINDOWS_DEFAULT);
    int64_t poses = 0;
    if (length < 2) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: windows of %d frames", (int)length);
    if (windows * length > INT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: %lld windows of %lld frames are too many",
                        (long long)windows, (long long)length);
    if (d->kind == GSF_TRAJ_REFERENCE) {
        int32_t side, middle;
        gsf__traj_split_window((int32_t)length, &side, &middle);
        const int64_t room = middle < 1 ? 1 : middle, share = (5 * room * windows + 3) / 7;
        poses = gsf__traj_or(d->ellipse_poses, windows == 1 ? room : share > room ? share : room);
    } else if (d->kind == GSF_TRAJ_ELLIPSE) {
        poses = gsf__traj_or(d->ellipse_poses, windows * length);
    }
    if (poses > INT32_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: %lld poses on the ellipse", (long long)poses);
    out->window_length = (int32_t)length;
    out->window_count = (int32_t)windows;
    out->ellipse_poses = (int32_t)poses;
    return GSF_OK;
}

enum { GSF__TRAJ_SAMPLE = 4096 }; // at most twice as many points, evenly spaced, stand for the cloud

// Per view the depth that it looks at, then the workspace of medians of depths or of positions.
static size_t gsf__traj_spread_scratch(size_t count) {
    const size_t most = gsf__traj_size_max(gsf__traj_principal_axes_scratch(count), 2 * GSF__TRAJ_SAMPLE * sizeof(double));
    return gsf__traj_size_add(gsf__traj_size_mul(count, sizeof(double)), most);
}

static gsf_traj_path_desc gsf__traj_path_desc_defaults(const gsf_traj_path_desc* desc) {
    gsf_traj_path_desc out;
    memset(&out, 0, sizeof out);
    if (desc) out = *desc;
    if (!out.points || !out.point_count) {
        out.points = NULL;
        out.point_count = 0;
    }
    return out;
}

GSF_API gsf_result gsf_traj_query_path(gsf_context* ctx, size_t camera_count, const gsf_traj_path_desc* desc,
                                       gsf_traj_path_info* layout) {
    memset(layout, 0, sizeof *layout);
    const gsf_traj_path_desc d = gsf__traj_path_desc_defaults(desc);
    if ((int)d.kind < 0 || d.kind > GSF_TRAJ_SPREAD)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: kind is %d", (int)d.kind);
    if (d.window_length < 0 || d.window_count < 0 || d.ellipse_poses < 0 || d.round < 0)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT,
                        "path: a count is negative (length %d, windows %d, poses %d, round %d)", (int)d.window_length,
                        (int)d.window_count, (int)d.ellipse_poses, (int)d.round);
    if (camera_count == 0) return gsf_fail(ctx, GSF_ERROR_DEGENERATE, "path: no camera");
    if (camera_count > INT32_MAX) return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: %zu cameras", camera_count);
    gsf_traj_path_info out;
    memset(&out, 0, sizeof out);
    GSF__TRY(gsf__traj_resolve_path(ctx, camera_count, &d, &out));
    out.frame_count = gsf__traj_size_mul((size_t)out.window_count, (size_t)out.window_length);
    // Scratch layout: [local poses of the cameras][poses of the ellipse][workspace of the current step]
    size_t work = gsf__traj_size_max(gsf__traj_normalize_scratch(camera_count, d.point_count),
                                     gsf__traj_ellipse_scratch(camera_count));
    if (d.kind == GSF_TRAJ_INTERPOLATE) work = gsf__traj_slerp_path_scratch(camera_count);
    if (d.kind == GSF_TRAJ_SPREAD) work = gsf__traj_spread_scratch(camera_count);
    const size_t poses = gsf__traj_size_add(camera_count, (size_t)out.ellipse_poses);
    out.scratch_bytes = gsf__traj_size_add(gsf__traj_size_mul(poses, 16 * sizeof(double)), work);
    if (out.scratch_bytes == SIZE_MAX || gsf__traj_size_mul(out.frame_count, sizeof(gsf_camera)) == SIZE_MAX)
        return gsf_fail(ctx, GSF_ERROR_INVALID_ARGUMENT, "path: more than memory can hold");
    *layout = out;
    return GSF_OK;
}

typedef struct gsf__traj_job { // shared by all kinds
    gsf_context* ctx;
    gsf_traj_path_desc desc;
    gsf_traj_path_info layout;
    const gsf_camera* cameras;
    size_t count;
    gsf_camera frame;    // size and intrinsics of the frames
    double origin[3];    // of local coordinates, in the world; the poses below are local until normalised
    double magnitude;    // of the world coordinates
    double to_local[16]; // normalised to local
    double* views;       // (count,16) poses of the cameras: local, then normalised
    double* loop;        // (ellipse_poses,16)
    double* work;
    gsf_camera* out;
    int32_t* reference_index;
} gsf__traj_job;

// Writes frame `at` from a pose in the frame of `to_local`.
static gsf_result gsf__traj_put_pose(gsf__traj_job* job, size_t at, const double pose[16]) {
    double world[16];
    gsf__traj_transform_poses(job->to_local, pose, 1, world);
    for (int i = 0; i < 3; i++) world[12 + i] += job->origin[i];
    job->out[at] = job->frame;
    gsf_set_camera_c2w(&job->out[at], world);
    if (job->reference_index) job->reference_index[at] = -1;
    if (!gsf__traj_finite(job->out[at].w2c, 16))
        return gsf_fail(job->ctx, GSF_ERROR_NUMERIC, "path: coordinates are too large to compute with");
    return GSF_OK;
}

// Writes frame `at` as the view of a camera.
static void gsf__traj_put_reference(gsf__traj_job* job, size_t at, int32_t camera) {
    const gsf_camera* own = &job->cameras[camera];
    job->out[at] = job->desc.official ? job->frame : gsf_resize_camera(own, job->frame.width, job->frame.height);
    memcpy(job->out[at].w2c, own->w2c, sizeof own->w2c);
    if (job->reference_index) job->reference_index[at] = camera;
}

static gsf_result gsf__traj_check_job(gsf__traj_job* job) {
    for (size_t n = 0; n < job->count; n++) {
        const gsf_result result = gsf_check_camera(job->ctx, &job->cameras[n]);
        if (result != GSF_OK) return gsf_fail(job->ctx, result, "path: camera %zu: %s", n, job->ctx->error);
    }
    job->frame = job->cameras[0];
    if (job->desc.intrinsics) {
        job->frame = *job->desc.intrinsics;
        memcpy(job->frame.w2c, job->cameras[0].w2c, sizeof job->frame.w2c);
        GSF__TRY(gsf_check_camera(job->ctx, &job->frame));
    }
    for (size_t n = 0; n < job->desc.point_count; n++)
        if (!gsf__traj_finite(job->desc.points + 3 * n, 3))
            return gsf_fail(job->ctx, GSF_ERROR_NUMERIC, "path: point %zu is not finite", n);
    if (job->desc.transform) GSF__TRY(gsf__traj_check_similarity(job->ctx, job->desc.transform));
    if (job->count < 2) return gsf_fail(job->ctx, GSF_ERROR_DEGENERATE, "path: one camera is not enough");
    return GSF_OK;
}

// Camera poses with exact rotations, relative to their mean position, so that rounding is the same as for a scene at the
// origin. The release's similarity depends on the world's origin, so with `official` the origin is kept.
static void gsf__traj_localize(gsf__traj_job* job) {
    for (size_t n = 0; n < job->count; n++) {
        double quat[4], *view = job->views + 16 * n;
        gsf_get_camera_c2w(&job->cameras[n], view);
        gsf__quat_of(view, quat);
        gsf__traj_quat_axes(quat, view);
    }
    job->magnitude = gsf__traj_magnitude(job->views + 12, job->count, 16);
    memset(job->origin, 0, sizeof job->origin);
    gsf__traj_identity(job->to_local);
    if (job->desc.official) return;
    gsf__traj_mean_column(job->views, job->count, 3, job->origin);
    for (size_t n = 0; n < job->count; n++)
        for (int i = 0; i < 3; i++) job->views[16 * n + 12 + (size_t)i] -= job->origin[i];
}

// Points of a job, seen from its views, which `transform` maps to from local coordinates.
static gsf__traj_cloud gsf__traj_job_cloud(const gsf__traj_job* job, const double transform[16]) {
    gsf__traj_cloud cloud;
    gsf__traj_cloud_init(&cloud, job->desc.points, job->desc.point_count, 3);
    memcpy(cloud.origin, job->origin, sizeof cloud.origin);
    memcpy(cloud.transform, transform, sizeof cloud.transform);
    return cloud;
}

// Median depth of the points in front of a view or, if there are none, `fallback`. work: 2 * GSF__TRAJ_SAMPLE.
static double gsf__traj_view_depth(const gsf__traj_cloud* cloud, const double* view, double fallback, double* work) {
    size_t before = 0;
    for (size_t k = 0; k < cloud->count; k += cloud->count / GSF__TRAJ_SAMPLE + 1) {
        double p[3];
        gsf__traj_cloud_point(cloud, k, p);
        for (int i = 0; i < 3; i++) p[i] -= view[12 + i];
        const double depth = gsf__traj_dot(view + 8, p);
        if (depth > 0.0) work[before++] = depth;
    }
    return before ? gsf__traj_median(work, before) : fallback;
}

// Largest distance of a view from the mean of their positions.
static double gsf__traj_views_radius(const gsf__traj_job* job) {
    double center[3], radius = 0.0;
    gsf__traj_mean_column(job->views, job->count, 3, center);
    for (size_t n = 0; n < job->count; n++) {
        const double d = gsf__traj_distance(job->views + 16 * n + 12, center);
        if (d > radius) radius = d;
    }
    return radius;
}

// Mean of the points that the views (normalised, by `transform`) look at. A view looks at the median depth of the points in
// front of it or, without any, at four times the radius of the cameras.
static void gsf__traj_looked_at(const gsf__traj_job* job, const double transform[16], double out[3]) {
    const gsf__traj_cloud cloud = gsf__traj_job_cloud(job, transform);
    const double radius = gsf__traj_views_radius(job);
    memset(out, 0, 3 * sizeof(double));
    for (size_t n = 0; n < job->count; n++) {
        const double* view = job->views + 16 * n;
        const double depth = gsf__traj_view_depth(&cloud, view, 4.0 * radius, job->work);
        for (int i = 0; i < 3; i++) out[i] += (view[12 + i] + depth * view[8 + i]) / (double)job->count;
    }
}

// The point that the loop looks at. Axes within half a degree of each other intersect far behind the scene, if at all; in
// this case the loop looks at the depth of the scene. The release does not handle it.
static gsf_result gsf__traj_focus(const gsf__traj_job* job, const double transform[16], double focus[3]) {
    const double parallel = 1e-4;
    if (job->desc.official) return gsf_traj_find_focus(job->ctx, job->views, job->count, focus);
    memset(focus, 0, 3 * sizeof(double));
    if (!(gsf__traj_solve_focus(job->views, job->count, 0.0, focus, focus) > parallel)) {
        double middle[3];
        gsf__traj_looked_at(job, transform, middle);
        (void)gsf__traj_solve_focus(job->views, job->count, parallel, middle, focus);
    }
    return gsf__traj_finite(focus, 3)
               ? GSF_OK
               : gsf_fail(job->ctx, GSF_ERROR_NUMERIC, "path: coordinates are too large to compute with");
}

// Moves the views into the normalised frame and samples the loop there.
static gsf_result gsf__traj_make_loop(gsf__traj_job* job) {
    double transform[16];
    if (job->desc.transform) { // T (local + origin)
        memcpy(transform, job->desc.transform, sizeof transform);
        gsf__traj_apply(transform, job->origin, transform + 12);
    } else {
        gsf__traj_similarity_desc similarity;
        memset(&similarity, 0, sizeof similarity);
        similarity.official = job->desc.official;
        GSF__TRY(gsf__traj_solve_frame(job->ctx, job->views, job->count, job->desc.points, job->desc.point_count,
                                     job->origin, job->magnitude, &similarity, job->work, transform));
    }
    GSF__TRY(gsf__traj_invert_similarity(job->ctx, transform, job->to_local));
    gsf__traj_transform_poses(transform, job->views, job->count, job->views);
    GSF__TRY(gsf__traj_check_path(job->ctx, job->views, job->count));
    gsf_traj_ellipse_desc ellipse = gsf__traj_round_ellipse(job->desc.round, job->desc.seed, 0);
    if (job->desc.ellipse) ellipse = *job->desc.ellipse;
    ellipse.frames = job->layout.ellipse_poses;
    double focus[3];
    GSF__TRY(gsf__traj_check_ellipse(job->ctx, &ellipse));
    GSF__TRY(gsf__traj_focus(job, transform, focus));
    return gsf__traj_ellipse(job->ctx, job->views, job->count, &ellipse, focus, job->work, job->loop);
}

static const double* gsf__traj_loop_pose(const gsf__traj_job* job, int64_t index) {
    return job->loop + 16 * (size_t)(index % job->layout.ellipse_poses);
}

// First pose of window w on the loop: by the release's table, or evenly spaced around the loop.
static int64_t gsf__traj_window_start(const gsf__traj_job* job, int64_t w, int32_t middle) {
    const int64_t poses = job->layout.ellipse_poses, windows = job->layout.window_count;
    return job->desc.official ? gsf__traj_table_start(gsf__traj_make_table(poses, middle), w) : w * poses / windows;
}

// One window of the reference-guided path: `side` frames from a photo to the loop, `middle` on it, `side` to a photo.
static gsf_result gsf__traj_reference_window(gsf__traj_job* job, int32_t w, int32_t side, int32_t middle) {
    const int64_t start = gsf__traj_window_start(job, w, middle);
    const int64_t end = middle > 0 ? start + middle - 1 : gsf__traj_window_start(job, w + 1, middle);
    const double *enter = gsf__traj_loop_pose(job, start), *leave = gsf__traj_loop_pose(job, end);
    const size_t base = (size_t)w * (size_t)job->layout.window_length;
    const size_t last = base + (size_t)job->layout.window_length - 1;
    int32_t from, to;
    GSF__TRY(gsf__traj_nearest_view(job->ctx, enter, job->views, job->count, 0.5, &from, NULL));
    GSF__TRY(gsf__traj_nearest_view(job->ctx, leave, job->views, job->count, 0.5, &to, NULL));
    const double *first_view = job->views + 16 * (size_t)from, *last_view = job->views + 16 * (size_t)to;
    for (int32_t i = 1; i < side; i++) {
        double in[16], back[16];
        if (!job->desc.official) {
            gsf__traj_blend_poses(first_view, enter, (double)i / side, in);
            gsf__traj_blend_poses(leave, last_view, (double)i / side, back);
        } else { // u = 0, 1/side .. (side - 2)/side, 1 on both legs
            const double u = i == side - 1 ? 1.0 : (double)i / side, v = (double)(i - 1) / side;
            if (!gsf__traj_blend_axes(first_view, enter, u, in) || !gsf__traj_blend_axes(leave, last_view, v, back))
                return gsf_fail(job->ctx, GSF_ERROR_DEGENERATE, "path: window %d: directions cancel", (int)w);
        }
        GSF__TRY(gsf__traj_put_pose(job, base + (size_t)i, in));
        GSF__TRY(gsf__traj_put_pose(job, last - (size_t)side + (size_t)i, back));
    }
    for (int32_t i = 0; i < middle; i++)
        GSF__TRY(gsf__traj_put_pose(job, base + (size_t)side + (size_t)i, gsf__traj_loop_pose(job, start + i)));
    gsf__traj_put_reference(job, base, from);
    gsf__traj_put_reference(job, last, to);
    return GSF_OK;
}

static gsf_result gsf__traj_sample_reference(gsf__traj_job* job) {
    int32_t side, middle;
    gsf__traj_split_window(job->layout.window_length, &side, &middle);
    GSF__TRY(gsf__traj_make_loop(job));
    for (int32_t w = 0; w < job->layout.window_count; w++) GSF__TRY(gsf__traj_reference_window(job, w, side, middle));
    return GSF_OK;
}

static gsf_result gsf__traj_sample_ellipse(gsf__traj_job* job) {
    GSF__TRY(gsf__traj_make_loop(job));
    for (size_t f = 0; f < job->layout.frame_count; f++)
        GSF__TRY(gsf__traj_put_pose(job, f, job->loop + 16 * (f % (size_t)job->layout.ellipse_poses)));
    return GSF_OK;
}

// Each window covers an equal part of the path through all cameras; neighbours share their end frames.
static gsf_result gsf__traj_sample_interpolate(gsf__traj_job* job) {
    gsf__traj_curve curve;
    if (!gsf__traj_make_glide(&curve, job->views, job->count, job->work))
        return gsf_fail(job->ctx, GSF_ERROR_DEGENERATE, "path: no spline through %zu cameras", job->count);
    const int64_t steps = job->layout.window_length - 1, legs = (int64_t)job->count - 1;
    const int64_t all = steps * job->layout.window_count;
    for (size_t f = 0; f < job->layout.frame_count; f++) {
        const int64_t window = (int64_t)f / job->layout.window_length;
        const int64_t step = window * steps + (int64_t)f % job->layout.window_length;
        const int64_t leg = legs * (step / all) + legs * (step % all) / all, part = legs * (step % all) % all;
        if (part == 0) {
            gsf__traj_put_reference(job, f, (int32_t)leg);
            continue;
        }
        double pose[16];
        gsf__traj_eval_glide(&curve, job->views, job->count, (double)leg + (double)part / (double)all, pose);
        GSF__TRY(gsf__traj_put_pose(job, f, pose));
    }
    return GSF_OK;
}

// ---- spread ----

#define GSF__TRAJ_SPREAD_REACH 1.3  // extent of the frames' box, in extents of the cameras' box
#define GSF__TRAJ_SPREAD_LEAST 0.15 // least half extent of the frames' box, in diagonals of the cameras' box
#define GSF__TRAJ_CLEARANCE 0.1     // distance from all points that is enough, in depths of what the nearest view looks at
enum { GSF__TRAJ_SPREAD_TRIES = 16 };

typedef struct gsf__traj_box { double center[3], axes[9], half[3], diagonal; } gsf__traj_box; // axes: rows, longest first

// The box of the positions along their principal axes, widened to that of the frames. Cameras on a line are turned about it
// so that their mean down or, if that is along the line, their mean forward direction is an axis. An axis points towards
// the cameras' mean right, down or forward, whichever is nearest to it, so that the path turns with the scene.
static gsf_result gsf__traj_spread_box(const gsf__traj_job* job, gsf__traj_box* out) {
    double mean[3][3], transform[16], square = 0.0;
    double *down = mean[1], *forward = mean[2];
    gsf__traj_cloud positions;
    gsf__traj_cloud_init(&positions, job->views + 12, job->count, 16);
    for (int c = 0; c < 3; c++) gsf__traj_mean_column(job->views, job->count, c, mean[c]);
    if (!gsf__traj_unit(down, down) || gsf__traj_cloud_axes(job->ctx, &positions, down, job->work, transform) != GSF_OK) {
        if (!gsf__traj_unit(forward, forward))
            return gsf_fail(job->ctx, GSF_ERROR_DEGENERATE, "path: the directions of the %zu cameras cancel", job->count);
        GSF__TRY(gsf__traj_cloud_axes(job->ctx, &positions, forward, job->work, transform));
    }
    memset(out->center, 0, sizeof out->center);
    for (int a = 0; a < 3; a++) {
        double low = (double)INFINITY, high = -(double)INFINITY;
        double most = 0.0;
        for (int i = 0; i < 3; i++) out->axes[3 * a + i] = transform[4 * i + a];
        for (int c = 0; c < 3; c++) {
            const double along = gsf__traj_dot(out->axes + 3 * a, mean[c]);
            if (fabs(along) > fabs(most)) most = along;
        }
        for (int i = 0; i < 3 && most < 0.0; i++) out->axes[3 * a + i] = -out->axes[3 * a + i];
        for (size_t n = 0; n < job->count; n++) {
            const double at = gsf__traj_dot(out->axes + 3 * a, job->views + 16 * n + 12);
            low = fmin(low, at), high = fmax(high, at);
        }
        square += (high - low) * (high - low);
        out->half[a] = 0.5 * GSF__TRAJ_SPREAD_REACH * (high - low);
        for (int i = 0; i < 3; i++) out->center[i] += 0.5 * (low + high) * out->axes[3 * a + i];
    }
    out->diagonal = sqrt(square);
    for (int a = 0; a < 3; a++) out->half[a] = fmax(out->half[a], GSF__TRAJ_SPREAD_LEAST * out->diagonal);
    return GSF_OK;
}

// The pose at `position` that looks at the mean of what the views look at, weighted by inverse squared distance from
// them. *depth: of what the nearest view looks at. Returns 0 if there is no such pose.
static int gsf__traj_spread_pose(const gsf__traj_job* job, const double* depths, double diagonal, const double position[3],
                                 double pose[16], double* depth) {
    double target[3] = {0.0, 0.0, 0.0}, down[3] = {0.0, 0.0, 0.0}, total = 0.0, nearest = (double)INFINITY;
    for (size_t n = 0; n < job->count; n++) {
        const double *view = job->views + 16 * n, d = gsf__traj_distance(view + 12, position) / diagonal;
        const double weight = 1.0 / (d * d + 0.0025); // within 5 % of the diagonal it no longer grows
        if (d < nearest) nearest = d, *depth = depths[n];
        total += weight;
        for (int i = 0; i < 3; i++) {
            target[i] += weight * (view[12 + i] + depths[n] * view[8 + i]);
            down[i] += weight * view[4 + i];
        }
    }
    for (int i = 0; i < 3; i++) target[i] = target[i] / total - position[i];
    return gsf__traj_length(down) > 1e-6 * total && gsf__traj_axes(target, down, position, pose);
}

static double gsf__traj_fraction(double x) { return x - floor(x); }

// Frames sweep along the longest axis of the box; their place on the others follows the R2 sequence (Roberts 2018), which
// continues from round to round. A frame too near to a point tries other places on these axes.
static gsf_result gsf__traj_sample_spread(gsf__traj_job* job) {
    const double steps[2] = {0.7548776662466927, 0.5698402909980532}; // 1/g and 1/g^2, where g^3 = g + 1
    gsf__traj_box box;
    GSF__TRY(gsf__traj_spread_box(job, &box));
    const gsf__traj_cloud cloud = gsf__traj_job_cloud(job, job->to_local);
    double *depths = job->work, *work = depths + job->count;
    for (size_t n = 0; n < job->count; n++)
        depths[n] = gsf__traj_view_depth(&cloud, job->views + 16 * n, 4.0 * gsf__traj_views_radius(job), work);
    const size_t frames = job->layout.frame_count;
    for (size_t f = 0; f < frames; f++) {
        double best = -1.0, chosen[16];
        for (int t = 0; t < GSF__TRAJ_SPREAD_TRIES && best < 1.0; t++) {
            const double index = (double)job->desc.round * (double)frames + (double)f;
            double place[3], position[3], pose[16], depth = 0.0, clear = (double)INFINITY;
            place[0] = ((double)f + 0.5) / (double)frames;
            for (int a = 0; a < 2; a++)
                place[1 + a] = gsf__traj_fraction(gsf_draw_uniform(job->desc.seed, 0x73707264u, (uint64_t)a) +
                                                  index * steps[a] + t * 0.3819660112501051);
            for (int i = 0; i < 3; i++) {
                position[i] = box.center[i];
                for (int a = 0; a < 3; a++) position[i] += (2.0 * place[a] - 1.0) * box.half[a] * box.axes[3 * a + i];
            }
            if (!gsf__traj_spread_pose(job, depths, box.diagonal, position, pose, &depth)) continue;
            for (size_t k = 0; k < cloud.count; k += cloud.count / GSF__TRAJ_SAMPLE + 1) {
                double p[3];
                gsf__traj_cloud_point(&cloud, k, p);
                clear = fmin(clear, gsf__traj_distance(p, position));
            }
            clear /= GSF__TRAJ_CLEARANCE * depth;
            if (!(clear > best)) continue;
            best = clear;
            memcpy(chosen, pose, sizeof chosen);
        }
        if (best < 0.0) return gsf_fail(job->ctx, GSF_ERROR_DEGENERATE, "path: frame %zu has no direction to look in", f);
        GSF__TRY(gsf__traj_put_pose(job, f, chosen));
    }
    return GSF_OK;
}

GSF_API gsf_result gsf_traj_sample_path(gsf_context* ctx, const gsf_camera* cameras, size_t camera_count,
                                        const gsf_traj_path_desc* desc, void* scratch, gsf_camera* out,
                                        int32_t* reference_index) {
    gsf__traj_job job;
    memset(&job, 0, sizeof job);
    job.ctx = ctx;
    job.desc = gsf__traj_path_desc_defaults(desc);
    GSF__TRY(gsf_traj_query_path(ctx, camera_count, &job.desc, &job.layout));
    job.cameras = cameras;
    job.count = camera_count;
    job.out = out;
    job.reference_index = reference_index;
    job.views = (double*)scratch;
    job.loop = job.views + 16 * camera_count;
    job.work = job.loop + 16 * (size_t)job.layout.ellipse_poses;
    gsf_result result = gsf__traj_check_job(&job);
    if (result == GSF_OK) {
        gsf__traj_localize(&job);
        result = job.desc.kind == GSF_TRAJ_REFERENCE     ? gsf__traj_sample_reference(&job)
                 : job.desc.kind == GSF_TRAJ_ELLIPSE     ? gsf__traj_sample_ellipse(&job)
                 : job.desc.kind == GSF_TRAJ_INTERPOLATE ? gsf__traj_sample_interpolate(&job)
                                                         : gsf__traj_sample_spread(&job);
    }
    if (result != GSF_OK) {
        memset(out, 0, job.layout.frame_count * sizeof *out);
        if (reference_index) memset(reference_index, 0, job.layout.frame_count * sizeof *reference_index);
    }
    return result;
}

GSF__END_IMPLEMENTATION

#endif // GSF_TRAJ_IMPLEMENTED
#endif // GSFIXER_TRAJ_IMPLEMENTATION
