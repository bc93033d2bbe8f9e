// gsfix.h - what the files of the program gsfix share
// SPDX-License-Identifier: MIT
#ifndef GSFIX_H
#define GSFIX_H

#ifndef _XOPEN_SOURCE
#define _XOPEN_SOURCE 700 // POSIX 2008 with realpath
#endif

#include "gsfixer_nn.h"
#include "gsfixer_splat.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct gsfix_options { // NULL, 0 or -1: not given; see the table in gsfix.c
    const char *out, *views, *restorer, *condition, *regularize, *trajectory, *init, *quality, *masks, *settings, *also;
    const char *scene, *path, *method, *kind, *refs, *which, *ref_features, *save_features;
    const char *caption, *model, *solver, *photo_masks, *background;
    int json, help, resume, restart, compare, depth, alpha, int8, bf16, any_frames;
    int threads, test_every, factor, max_size, iterations, eval_every, checkpoint_every, frames, windows, steps;
    double restorer_timeout, guidance, guidance_until, strength, block_cache;
    uint64_t seed;
    const char** inputs;
    int input_count;
} gsfix_options;

enum { GSFIX_CLIP_STAGES = 12 };

typedef struct gsfix_clip_stage { // what the restorer dit: did in all clips
    char name[16];
    double seconds, memory;  // memory: anonymous bytes that were resident behind its units, at most
} gsfix_clip_stage;

typedef struct gsfix_out gsfix_out; // gsfix_out.c

typedef struct gsfix_app {
    gsf_context ctx;
    gsfix_options o;
    gsfix_out* out;
    const char* command;
    char* command_line; // as typed, quoted for a shell
    double started;     // gsfix_now() at the start
    gsf_text json;      // what --json prints; the other output is for people
    int terminal;       // stderr is one
    int bar_shown;      // a progress bar stands on the terminal's last line
    double bar_time;
    int line_share;     // tenth of the work that the last plain progress line told
    double clip_line;   // gsfix_now() of the last line about the clip that is being restored
    double stage_begin; // of the unit of the restorer's work that is being done
    gsfix_clip_stage stages[GSFIX_CLIP_STAGES];
    int stage_count;
} gsfix_app;

// ---- gsfix_util.c --------------------------------------------------------------

typedef struct gsfix_path { char s[4096]; } gsfix_path;
typedef struct gsfix_names { char** names; size_t count; } gsfix_names;

double gsfix_now(void); // seconds, monotonic
uint64_t gsfix_peak_memory(void);
double gsfix_anonymous_memory(void); // resident bytes that are no file's, now; 0: unknown
double gsfix_physical_memory(void); // bytes that the machine has; 0: unknown
gsfix_path gsfix_pathf(const char* format, ...) GSF_PRINTF(1, 2);
int gsfix_exists(const char* path);
int gsfix_is_folder(const char* path);
gsf_result gsfix_make_folder(gsf_context* ctx, const char* path); // with its parents
// Sorted file names of a folder that end in one of the extensions (".png.jpg", lower case).
gsf_result gsfix_list(gsf_context* ctx, const char* folder, const char* extensions, gsfix_names* out);
void gsfix_free_names(gsf_context* ctx, gsfix_names* names);
char* gsfix_copy_text(gsf_context* ctx, const char* text, size_t size);
// Room for one more element of a list of `count`, of `size` bytes each.
gsf_result gsfix_grow(gsf_context* ctx, void** list, size_t* room, size_t count, size_t size);
// File name without folder and extension.
gsfix_path gsfix_stem(const char* path);
// Name (without extension) under which a view's pictures are written: unique within the scene, no folders.
gsfix_path gsfix_view_stem(const gsf_scene* scene, size_t view);
gsf_result gsfix_save_npy(gsf_context* ctx, const char* path, const gsf_image* image); // f32, one channel
gsf_result gsfix_load_npy(gsf_context* ctx, const char* path, gsf_image* out);
// gsf_save_image for each; they are encoded all at once, which takes longer than rendering.
gsf_result gsfix_save_images(gsf_context* ctx, const gsfix_path* paths, const gsf_image* images, size_t count);
void gsfix_clamp(gsf_image* image); // packed f32 to [0,1], NaN to 0
int gsfix_counts_any(const gsf_image* mask); // a u8 mask of one channel has a pixel that counts
// Picture of packed f32 values: t = (value - low) / (high - low) through a perceptual map (warm: black to yellow).
gsf_result gsfix_color_map(gsf_context* ctx, const gsf_image* values, double low, double high, gsf_image* out);
// Depth as people like to see it: near is bright, scaled to the depths that are there; black where nothing is.
gsf_result gsfix_color_depth(gsf_context* ctx, const gsf_image* depth, gsf_image* out);
void gsfix_map_color(double t, uint8_t rgb[3]);
gsf_result gsfix_mean_abs_error(gsf_context* ctx, const gsf_image* a, const gsf_image* b, gsf_image* out); // f32, 1 channel

void gsfix_progress(gsfix_app* app, double done, double total, const char* format, ...) GSF_PRINTF(4, 5);
void gsfix_note(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3);   // a line on stderr
void gsfix_print(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3);  // on stdout, unless --json
void gsfix_hide_bar(gsfix_app* app);
int gsfix_misused(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3); // one line on stderr; returns 2
int gsfix_background(gsfix_app* app, float out[3], int32_t* random); // of --background; 0, or an exit code
int gsfix_failed(gsfix_app* app);                                            // likewise from ctx.error; returns 1

// A JSON object grows member by member in a gsf_text.
void gsfix_json_begin(gsf_context* ctx, gsf_text* text, const char* key, char bracket); // key NULL: none
void gsfix_json_end(gsf_context* ctx, gsf_text* text, char bracket);
void gsfix_json_text(gsf_context* ctx, gsf_text* text, const char* key, const char* value); // NULL: null
void gsfix_json_number(gsf_context* ctx, gsf_text* text, const char* key, double value);
void gsfix_json_bool(gsf_context* ctx, gsf_text* text, const char* key, int value);

// ---- gsfix_out.c: whose file is whose -------------------------------------------

typedef struct gsfix_read_file { char* path; uint64_t size, digest; } gsfix_read_file;

gsf_result gsfix_begin_files(gsfix_app* app); // from here on files are read and written through the hooks of gsfix_out.c
void gsfix_end_files(gsfix_app* app);
// A file or folder that outputs must keep away from. What is read or named on the command line is known without this.
gsf_result gsfix_add_input(gsfix_app* app, const char* path);
gsf_result gsfix_add_scene_inputs(gsfix_app* app, const gsf_scene* scene); // its photos, read or not
gsf_result gsfix_digest_input(gsfix_app* app, const char* path); // of a file that is mapped, not read; NULL: nothing
// What was read so far, in that order, with XXH64 digests; what is read from now on is no input.
const gsfix_read_file* gsfix_end_inputs(gsfix_app* app, size_t* count);

// A command claims each name below OUT that it may write ('*': any text without '/'), then opens OUT: fails with one line
// where a file in the way was not written by gsfix, or OUT cannot be used. Nothing is changed so far.
gsf_result gsfix_claim(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3);
gsf_result gsfix_open_out(gsfix_app* app);
gsf_result gsfix_claim_file(gsfix_app* app, const char* path); // a file elsewhere that must be new; after gsfix_open_out
// Removes what an earlier run of the same command wrote and this one will not write again.
gsf_result gsfix_remove_stale(gsfix_app* app);
gsf_result gsfix_remove_output(gsfix_app* app, const char* name); // if it is there and ours
int gsfix_has_output(gsfix_app* app, const char* name);           // is it?
gsfix_path gsfix_absolute(const char* path); // without links on the way; empty: there is no such folder

// A fresh folder in OUT for a restorer. Only what lies in it is ever emptied or removed.
gsf_result gsfix_make_job(gsfix_app* app, const char** path);
gsf_result gsfix_empty_job(gsfix_app* app, const char* name); // its subfolder: made, or emptied
gsf_result gsfix_check_job(gsfix_app* app, const char* name); // fails where the subfolder has become something else
void gsfix_leave_job(gsfix_app* app, int remove);

// ---- gsfix_exec.c --------------------------------------------------------------

// Restorer that runs `COMMAND JOBDIR` for each window. Freed by gsfix_destroy_exec.
gsf_result gsfix_make_exec(gsfix_app* app, const char* command, double timeout, gsf_restorer* out);
void gsfix_destroy_exec(gsf_context* ctx, gsf_restorer* restorer);

// ---- gsfix.c: what several commands need -----------------------------------------

typedef struct gsfix_split { uint32_t *train, *test; size_t train_count, test_count; } gsfix_split;

gsf_result gsfix_load_scene(gsfix_app* app, const char* path, gsf_scene* out);
gsf_result gsfix_split_scene(gsfix_app* app, const gsf_scene* scene, gsfix_split* out);
void gsfix_free_split(gsfix_app* app, gsfix_split* split);
gsf_result gsfix_camera_list(gsfix_app* app, const gsf_scene* scene, const uint32_t* views, size_t count,
                             gsf_camera** out); // freed with gsf_free
// 0 = fine; else the exit code, with its line printed.
int gsfix_check_restorer(gsfix_app* app);
gsf_result gsfix_make_restorer(gsfix_app* app, gsf_restorer* out, int* present);
void gsfix_destroy_restorer(gsfix_app* app, gsf_restorer* restorer);
void gsfix_json_stages(gsfix_app* app, gsf_text* text); // "restorer_stages": [...], where there were any
void gsfix_print_stages(gsfix_app* app);
extern const char* const gsfix_conditions[4]; // how --condition spells gsf_nn_condition
extern const char* const gsfix_solvers[3];    // and --solver gsf_nn_solver
gsf_nn_dit_desc gsfix_dit_desc(const gsfix_app* app);      // as the options have it, for --restorer dit:MODEL_DIR
gsf_result gsfix_drop_dit_checkpoint(gsfix_app* app);      // of the clip that was at work, when the whole is done
gsf_traj_kind gsfix_path_kind(const char* name);

// ---- gsfix_fix.c, gsfix_report.c -------------------------------------------------

typedef struct gsfix_quality { // --quality is one of these rows
    const char* name;
    gsf_quality work; // of training and of the loop
    int32_t steps;    // of the restorer dit:
    gsf_nn_solver solver;
    int bf16;
} gsfix_quality;
const gsfix_quality* gsfix_find_quality(const char* name); // NULL: the default

typedef struct gsfix_score { double psnr, ssim, psnr_seen, ssim_seen; } gsfix_score; // NaN: not measured
typedef struct gsfix_curve_point { int32_t iteration; uint64_t splats; double psnr, psnr_seen; } gsfix_curve_point;
typedef struct gsfix_round { int32_t round, iteration, windows, skipped, frames; double confidence; } gsfix_round;
typedef struct gsfix_flown { int32_t round, window, reference; double center[3], forward[3]; } gsfix_flown; // path frame
typedef struct gsfix_sample { int32_t round, window, frame; } gsfix_sample; // pictures of it lie in DIR/report

enum { GSFIX_INIT, GSFIX_TRAIN, GSFIX_RENDER, GSFIX_RESTORE, GSFIX_DISTILL, GSFIX_CHECKPOINT, GSFIX_SAVE, GSFIX_COMPARE,
       GSFIX_STAGES };
extern const char* const gsfix_stage_names[GSFIX_STAGES];

typedef struct gsfix_history { // what a run remembers beside the fixer's state; part of the checkpoint
    double seconds[GSFIX_STAGES], seconds_total;
    int32_t resumed;
    int32_t has_without;
    gsfix_score* without; // one per test view, once has_without: after as many steps without repair (--compare)
    gsfix_curve_point* without_curve;
    size_t view_count;
    gsfix_curve_point* curve;
    gsfix_round* rounds;
    gsfix_flown* path;
    gsfix_sample* samples;
    size_t curve_count, without_count, round_count, path_count, sample_count;
    size_t curve_room, without_room, round_room, path_room, sample_room;
} gsfix_history;

typedef struct gsfix_result { // of a finished run, for metrics.json and the report
    const gsf_scene* scene;
    const gsfix_split* split;
    const gsfix_history* history;
    const char* out;
    const char* switches;    // JSON object
    gsfix_score mean, without;
    const gsfix_score* views; // one per test view
    const gsf_image* masks;   // per test view; NULL = none given
    const gsf_splats* splats;
    int32_t iterations;
} gsfix_result;

gsf_result gsfix_write_report(gsfix_app* app, const gsfix_result* result);

int gsfix_run_fix(gsfix_app* app);

#endif
