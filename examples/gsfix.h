// gsfix.h - shared declarations of the program gsfix
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
    const char *scene, *path, *with, *depth_as, *method, *kind, *refs, *which, *models, *prompt, *ref_features, *save_features;
    const char *lora, *caption, *model, *solver, *photo_masks, *background, *kinds, *task;
    const char *restorers, *trajectories, *inits, *conditions, *tables, *benchmark, *screenshot, *video;
    int json, help, resume, restart, compare, depth, alpha, int8, bf16, any_frames, list_tasks, filtered, fixed_exposure;
    int threads, test_every, factor, max_size, iterations, eval_every, checkpoint_every, frames, windows, steps;
    int clean_iterations, seeds, spz_version, fps, copies;
    double restorer_timeout, guidance, guidance_until, strength, block_cache, orbit;
    uint64_t seed;
    const char** inputs;
    int input_count;
} gsfix_options;

enum { GSFIX_CLIP_STAGES = 12 };

typedef struct gsfix_clip_stage { // one stage of the restorer dit, summed over all clips
    char name[16];
    double seconds, memory;  // memory: peak of resident anonymous bytes
} gsfix_clip_stage;

typedef struct gsfix_out gsfix_out; // defined in gsfix_out.c

typedef struct gsfix_app {
    gsf_context ctx;
    gsfix_options o;
    gsfix_out* out;
    const char* command;
    char* command_line; // as typed, quoted for a shell
    double started;     // gsfix_now() at the start
    gsf_buffer json;    // the object that --json prints
    int terminal;       // stderr is a terminal
    int bar_shown;      // the last line of the terminal is a progress bar
    double bar_time;
    int line_share;     // tenth of the work that the last plain progress line reported
    double clip_line;   // gsfix_now() of the last progress line of the current clip
    double stage_begin; // gsfix_now() at the start of the restorer's current unit of work
    const struct gsfix_crew* crew; // does the tasks of gsfix_run_tasks; NULL: this process, one after the other
    gsfix_clip_stage stages[GSFIX_CLIP_STAGES];
    int stage_count;
    double depth_step; // of --depth-as png16: scene units
} gsfix_app;

// ---- gsfix_util.c --------------------------------------------------------------

typedef struct gsfix_path { char s[4096]; } gsfix_path;
typedef struct gsfix_names { char** names; size_t count; } gsfix_names;

double gsfix_now(void); // seconds, monotonic
uint64_t gsfix_peak_memory(void);
double gsfix_anonymous_memory(void); // resident bytes not backed by files, at present; 0: unknown
double gsfix_physical_memory(void);  // bytes of RAM; 0: unknown
gsfix_path gsfix_pathf(const char* format, ...) GSF_PRINTF(1, 2);
int gsfix_exists(const char* path);
int gsfix_is_folder(const char* path);
uint64_t gsfix_file_size(const char* path); // 0: there is none
gsf_result gsfix_make_folder(gsf_context* ctx, const char* path); // creates missing parents, too
// Sorted file names of a folder that end in one of the extensions (".png.jpg", lower case).
gsf_result gsfix_list(gsf_context* ctx, const char* folder, const char* extensions, gsfix_names* out);
void gsfix_free_names(gsf_context* ctx, gsfix_names* names);
char* gsfix_copy_text(gsf_context* ctx, const char* text, size_t size);
// Makes room for one more element of `size` bytes in a list of `count`.
gsf_result gsfix_grow(gsf_context* ctx, void** list, size_t* room, size_t count, size_t size);
// File name without folder and extension.
gsfix_path gsfix_stem(const char* path);
// Name (without extension) under which a view's pictures are written: unique within the scene, no folders.
gsfix_path gsfix_view_stem(const gsf_scene* scene, size_t view);
gsf_result gsfix_save_npy(gsf_context* ctx, const char* path, const gsf_image* image); // f32, one channel
gsf_result gsfix_load_npy(gsf_context* ctx, const char* path, gsf_image* out);
// gsf_save_image for each; in parallel, since encoding takes longer than rendering.
gsf_result gsfix_save_images(gsf_context* ctx, const gsfix_path* paths, const gsf_image* images, size_t count);
void gsfix_clamp(gsf_image* image);          // clamps packed f32 to [0,1], NaN to 0
int gsfix_counts_any(const gsf_image* mask); // does a u8 mask of one channel have a pixel that counts?
// Colour-maps packed f32 values: t = (value - low) / (high - low) on a perceptually uniform map (warm: black to yellow).
gsf_result gsfix_color_map(gsf_context* ctx, const gsf_image* values, double low, double high, gsf_image* out);
// Depth for display: near is bright, scaled to the range of the depths; black where there is none.
gsf_result gsfix_color_depth(gsf_context* ctx, const gsf_image* depth, gsf_image* out);
void gsfix_map_color(double t, uint8_t rgb[3]);
gsf_result gsfix_mean_abs_error(gsf_context* ctx, const gsf_image* a, const gsf_image* b, gsf_image* out); // f32, 1 channel

void gsfix_progress(gsfix_app* app, double done, double total, const char* format, ...) GSF_PRINTF(4, 5);
void gsfix_note(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3);   // prints a line to stderr
void gsfix_print(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3);  // prints to stdout, unless --json
void gsfix_hide_bar(gsfix_app* app);
int gsfix_misused(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3); // one line on stderr; returns 2
int gsfix_background(gsfix_app* app, const char* text, float out[3], gsf_background* kind); // 0 or an exit code
int gsfix_splats_background(gsfix_app* app, float out[3]); // of --background, if given; 0 or an exit code
int gsfix_failed(gsfix_app* app); // prints ctx.error; returns 1

// Append members to a JSON object in a gsf_buffer.
void gsfix_json_begin(gsf_context* ctx, gsf_buffer* text, const char* key, char bracket); // key NULL: no key
void gsfix_json_end(gsf_context* ctx, gsf_buffer* text, char bracket);
void gsfix_json_text(gsf_context* ctx, gsf_buffer* text, const char* key, const char* value); // NULL: null
void gsfix_json_number(gsf_context* ctx, gsf_buffer* text, const char* key, double value);
void gsfix_json_bool(gsf_context* ctx, gsf_buffer* text, const char* key, int value);

// ---- gsfix_out.c: ownership of files ---------------------------------------------

typedef struct gsfix_read_file { char* path; uint64_t size, digest; } gsfix_read_file;

gsf_result gsfix_begin_files(gsfix_app* app); // installs the read and write hooks of gsfix_out.c
void gsfix_end_files(gsfix_app* app);
// Declares a file or folder as an input, which outputs must not touch. Files that are read or named on the command line are
// inputs without this.
gsf_result gsfix_add_input(gsfix_app* app, const char* path);
gsf_result gsfix_add_scene_inputs(gsfix_app* app, const gsf_scene* scene); // the scene's photos, whether read or not
// For files that are mapped instead of read; NULL: does nothing.
gsf_result gsfix_digest_input(gsfix_app* app, const char* path);
// The files read so far, in order, with XXH64 digests. Files read from now on are not inputs.
const gsfix_read_file* gsfix_end_inputs(gsfix_app* app, size_t* count);

// A command claims each name below OUT that it may write ('*' matches any text without '/') and then opens OUT. Opening fails
// with a message if a claimed name is taken by a file that gsfix did not write, or if OUT cannot be used; nothing has been
// changed then.
gsf_result gsfix_claim(gsfix_app* app, const char* format, ...) GSF_PRINTF(2, 3);
gsf_result gsfix_open_out(gsfix_app* app);
gsf_result gsfix_claim_file(gsfix_app* app, const char* path); // a new file outside OUT; call after gsfix_open_out
// Removes files that an earlier run of the same command wrote and this one does not write again.
gsf_result gsfix_remove_stale(gsfix_app* app);
gsf_result gsfix_remove_output(gsfix_app* app, const char* name); // if it exists and is ours
int gsfix_has_output(gsfix_app* app, const char* name);           // does it exist and is it ours?
// The same; sets size and XXH64 digest of a file that is ours.
int gsfix_query_output(gsfix_app* app, const char* name, uint64_t* size, uint64_t* digest);
uint64_t gsfix_digest(const void* data, size_t size); // XXH64
int gsfix_digest_file(const char* path, uint64_t* size, uint64_t* digest); // 0: it cannot be read
gsfix_path gsfix_absolute(const char* path); // with links resolved; empty if there is no such folder

// A new folder in OUT for a restorer's job. Nothing outside it is ever emptied or removed.
gsf_result gsfix_make_job(gsfix_app* app, const char** path);
gsf_result gsfix_empty_job(gsfix_app* app, const char* name); // creates or empties a subfolder
gsf_result gsfix_check_job(gsfix_app* app, const char* name); // fails if the subfolder has been replaced by something else
void gsfix_leave_job(gsfix_app* app, int remove);

// A file for another program to write, OUT/.gsfix/draft: it is published as a file that gsfix writes, or else removed.
gsf_result gsfix_begin_draft(gsfix_app* app, gsfix_path* path);
gsf_result gsfix_publish_draft(gsfix_app* app, const char* path);
void gsfix_drop_draft(gsfix_app* app);

// ---- gsfix_process.c -----------------------------------------------------------

typedef struct gsfix_process { // another program; zeroed except for name and code
    const char* name;  // how messages begin
    gsf_result code;   // of failures
    char said[200];    // the first line of what it says, if its streams are pipes
    size_t said_size;
    int said_all;
    intptr_t group, life, child, input, errors; // 0: none
} gsfix_process;

int gsfix_find_program(const char* name, gsfix_path* out); // in PATH; 0: not found
// arguments: the program's path and arguments, then NULL; on Windows joined by blanks, to be quoted by the caller. `piped`: it
// reads what it is fed, and what it says is kept for messages; otherwise it shares gsfix's input and standard error.
gsf_result gsfix_start_process(gsf_context* ctx, gsfix_process* p, const char* const* arguments, int piped);
// timeout: seconds in which it takes nothing.
gsf_result gsfix_feed_process(gsf_context* ctx, gsfix_process* p, const void* data, size_t size, double timeout);
gsf_result gsfix_wait_process(gsf_context* ctx, gsfix_process* p, double timeout); // ends its input; fails on a status but 0
void gsfix_end_process(gsfix_process* p); // at once, with all that it has started; may be called again

// ---- gsfix_video.c ---------------------------------------------------------------

typedef struct gsfix_video gsfix_video;
int gsfix_check_video(gsfix_app* app); // --video and --fps; 0 or an exit code after a message
// The functions do nothing without --video. Frames that are smaller than width x height are centred. Destroy after errors, too.
gsf_result gsfix_begin_video(gsfix_app* app, int64_t width, int64_t height, size_t frames, gsfix_video** out);
gsf_result gsfix_add_frame(gsfix_video* video, const gsf_image* frame);
gsf_result gsfix_finish_video(gsfix_video* video); // writes the file
void gsfix_destroy_video(gsfix_video* video);

// ---- gsfix_exec.c --------------------------------------------------------------

// Restorer that runs `COMMAND JOBDIR` for each window.
gsf_result gsfix_make_exec(gsfix_app* app, const char* command, double timeout, gsf_restorer* out);

// ---- gsfix.c: shared by several commands ------------------------------------------

int gsfix_start(int argc, char** argv, const struct gsfix_crew* crew); // the program; main without a crew

typedef struct gsfix_split { uint32_t *train, *test; size_t train_count, test_count; } gsfix_split;

gsf_result gsfix_load_scene(gsfix_app* app, const char* path, gsf_scene* out);
gsf_result gsfix_split_scene(gsfix_app* app, const gsf_scene* scene, gsfix_split* out);
void gsfix_free_split(gsfix_app* app, gsfix_split* split);
gsf_result gsfix_camera_list(gsfix_app* app, const gsf_scene* scene, const uint32_t* views, size_t count,
                             gsf_camera** out); // freed with gsf_free
// Returns 0, or an exit code after printing a message.
int gsfix_check_restorer(gsfix_app* app);
gsf_result gsfix_make_restorer(gsfix_app* app, gsf_restorer* out, int* present);
void gsfix_json_stages(gsfix_app* app, gsf_buffer* text); // "restorer_stages": [...], if there are any
void gsfix_print_stages(gsfix_app* app);
extern const char* const gsfix_conditions[4]; // names of gsf_nn_condition for --condition
extern const char* const gsfix_solvers[3];    // names of gsf_nn_solver for --solver
gsf_nn_dit_desc gsfix_dit_desc(const gsfix_app* app); // from the options, for --restorer dit:MODEL_DIR
gsf_result gsfix_drop_dit_checkpoint(gsfix_app* app); // removes the last clip's checkpoint when the run is complete
gsf_traj_kind gsfix_path_kind(const char* name);

typedef struct gsfix_clip { // frames, photos and what a restorer makes of them
    gsfix_names frame_names, ref_names;
    size_t frames, refs;
    gsf_image *color, *depth, *alpha, *out_color, *out_confidence; // per frame; depth, alpha: or NULL
    gsf_camera *cameras, *ref_cameras;
    size_t camera_count, ref_camera_count;
    int32_t* reference_index;
    gsf_reference* references;
} gsfix_clip;
gsf_result gsfix_make_clip(gsf_context* ctx, size_t frames, gsfix_clip* c); // fills in the lists of frames of a zeroed clip
gsf_result gsfix_restore_clip(gsfix_app* app, gsfix_clip* c, gsf_restorer* restorer);
void gsfix_free_clip(gsfix_app* app, gsfix_clip* c);
gsf_result gsfix_load_float(gsf_context* ctx, const char* path, int32_t channels, gsf_image* out); // as f32

typedef struct gsfix_meter gsfix_meter; // mean values of metrics over pairs of images, and values of a clip
// which: names of metrics in this version, separated by commas. Opens their networks in --models. prompt: for
// overall_consistency; frames: of the clip. To be destroyed after errors, too.
gsf_result gsfix_make_meter(gsfix_app* app, const char* which, const char* prompt, size_t frames, gsfix_meter** out);
// truth NULL: the frame does not count for metrics of pairs; input: of the metrics of clips, NULL: the frame is not in a clip.
gsf_result gsfix_meter_frame(gsfix_app* app, gsfix_meter* meter, const gsf_image* frame, const gsf_image* truth,
                             const gsf_image* input);
double gsfix_read_meter(const gsfix_meter* meter, const char* name); // NaN: not measured
void gsfix_destroy_meter(gsfix_app* app, gsfix_meter* meter);

// ---- gsfix_view.c ----------------------------------------------------------------

int gsfix_run_view(gsfix_app* app);

// ---- gsfix_tasks.c: commands whose work is a list of tasks ------------------------
/* A task has a folder of its own, OUT/NAME, with its own manifest and lock, and writes nothing else. What it writes depends
   on the command line and the inputs only, so that any process may do it, and another one may finish what a killed one
   began. merge_fn then writes the files in OUT itself from the tasks' folders.
       gsfix COMMAND ...              all tasks that are not done yet, in order, then merges
       gsfix COMMAND ... --tasks      prints their names
       gsfix COMMAND ... --task NAME  does one, does not merge
   gsfix_mpi distributes any command that is made like this. */
typedef struct gsfix_tasks {
    char** names; // file names, different from each other
    size_t count;
    void* user;
    // Claims what merge_fn writes, in OUT; called before any work, so that a refusal comes early.
    gsf_result (*claim_fn)(gsfix_app* app, void* user);
    // With --resume: is the task complete, so that there is nothing to do? Cheap. o.out is the task's folder.
    int (*done_fn)(gsfix_app* app, void* user, size_t task);
    // o.out is the task's folder, which it claims and opens (gsfix_open_out) as a command does; app->json is its own object.
    gsf_result (*run_fn)(gsfix_app* app, void* user, size_t task);
    // o.out is OUT, claimed and open. All tasks are done.
    gsf_result (*merge_fn)(gsfix_app* app, void* user);
    const size_t* needs; // per task an earlier one that has to be done first, or its own index; NULL: no task needs another
    int merges_partly;   // merge_fn is called although tasks have failed, and says what is missing
} gsfix_tasks;
int gsfix_run_tasks(gsfix_app* app, const gsfix_tasks* tasks); // returns an exit code

typedef struct gsfix_tally { // what became of the tasks so far
    const gsfix_tasks* tasks;
    uint8_t* done; // per task
    size_t failed;
    gsf_result why;      // of the first failure
    char first[400];     // its text
} gsfix_tally;
// A task has ended. `text`: why it failed, not read otherwise.
void gsfix_note_task(gsfix_app* app, gsfix_tally* tally, size_t task, gsf_result result, const char* text);
// Does all tasks, in an order that respects `needs`, and notes each; returns GSF_OK unless it was cancelled or cannot go on.
typedef struct gsfix_crew {
    gsf_result (*run_fn)(gsfix_app* app, void* user, gsfix_tally* tally);
    void* user;
} gsfix_crew;
// Names for tasks from the paths of scenes: their last parts, with the part before where those are equal.
gsf_result gsfix_name_scenes(gsfix_app* app, char*** names); // one per input; freed by gsfix_free_names
// ---- gsfix_fix.c, gsfix_report.c -------------------------------------------------

typedef struct gsfix_quality { // --quality is one of these rows
    const char* name;
    gsf_quality work; // for training and the loop
    int32_t steps;    // denoising steps of dit
    gsf_nn_solver solver;
    int bf16;
} gsfix_quality;
const gsfix_quality* gsfix_find_quality(const char* name); // NULL: the default

typedef struct gsfix_setup { // everything that determines a training
    gsf_fix_desc fix;
    gsf_initial_desc initial; // with its defaults filled in once the splats are made
} gsfix_setup;
// From the options; 0 or an exit code. What depends on the number of photos or on the start is filled in by gsfix_settle_train.
int gsfix_resolve_setup(gsfix_app* app, gsfix_setup* setup);
void gsfix_settle_train(gsf_train_desc* train, gsf_initial_kind start, size_t view_count);
// Fails, naming the member, if `now` (a JSON object) has a member that differs from that of `was`, or that `was` lacks.
gsf_result gsfix_compare_settings(gsf_context* ctx, const char* name, const gsf_buffer* now, const gsf_json* old,
                                  const gsf_json_value* was);

typedef struct gsfix_score { double psnr, ssim, psnr_seen, ssim_seen; } gsfix_score; // NaN: not measured
typedef struct gsfix_curve_point { int32_t iteration; uint64_t splats; double psnr, psnr_seen; } gsfix_curve_point;
typedef struct gsfix_round { int32_t round, iteration, windows, skipped, frames; double confidence; } gsfix_round;
// A frame of the path.
typedef struct gsfix_flown { int32_t round, window, reference; double center[3], forward[3]; } gsfix_flown;
typedef struct gsfix_sample { int32_t round, window, frame; } gsfix_sample; // a frame whose images are in DIR/report

enum { GSFIX_INIT, GSFIX_TRAIN, GSFIX_RENDER, GSFIX_RESTORE, GSFIX_DISTILL, GSFIX_CHECKPOINT, GSFIX_SAVE, GSFIX_COMPARE,
       GSFIX_COPIES, GSFIX_STAGES };
extern const char* const gsfix_stage_names[GSFIX_STAGES];

enum { GSFIX_COPIES_MOST = 16 }; // the run itself included, see --copies

typedef struct gsfix_history { // record of the run, stored in the checkpoint next to the fixer's state
    double seconds[GSFIX_STAGES], seconds_total;
    int32_t resumed;
    int32_t has_without;
    gsfix_score* without; // one per test view if has_without: scores of the run without repair (--compare)
    gsfix_curve_point* without_curve;
    size_t view_count;
    gsfix_curve_point* curve;
    gsfix_round* rounds;
    gsfix_flown* path;
    gsfix_sample* samples;
    size_t curve_count, without_count, round_count, path_count, sample_count;
    size_t curve_room, without_room, round_room, path_room, sample_room;
} gsfix_history;

typedef struct gsfix_result { // results of a finished run, for metrics.json and the report
    const gsf_scene* scene;
    const gsfix_split* split;
    const gsfix_history* history;
    const char* out;
    const char* switches;    // JSON object
    gsfix_score mean, without, filtered;
    const gsfix_score* views; // one per test view
    const gsfix_score* filtered_views; // likewise, of the renders that the restorer has cleaned up; NULL: --filtered not given
    size_t copies;            // that were joined, the run itself included; 1: --copies not given
    double first_copy;        // mean PSNR of the run itself
    const gsf_image* masks;   // per test view; NULL = none given
    const gsf_splats* splats;
    gsf_render_desc render;   // what the splats were trained with, the near plane included
    int32_t iterations;
} gsfix_result;

gsf_result gsfix_write_report(gsfix_app* app, const gsfix_result* result);

int gsfix_run_fix(gsfix_app* app);

// A run of fix inside another command: it writes OUT/checkpoint, which stays, OUT/test/*.png, and what finish_fn writes.
typedef struct gsfix_fix_task {
    gsf_result (*claim_fn)(gsfix_app* app, void* user);                               // claims what finish_fn writes
    gsf_result (*finish_fn)(gsfix_app* app, const gsfix_result* result, void* user);
    void* user;
} gsfix_fix_task;
gsf_result gsfix_fix_scene(gsfix_app* app, const gsfix_setup* setup, const gsfix_fix_task* task); // task NULL: gsfix fix

// ---- pages: parts of report.html that other pages share (gsfix_report.c) -------------

typedef struct gsfix_page {
    gsf_context* ctx;
    const gsfix_result* r; // what report.html is about; other pages: NULL
    gsf_buffer html;
} gsfix_page;

void gsfix_put(gsfix_page* p, const char* format, ...) GSF_PRINTF(2, 3); // up to 4095 bytes
void gsfix_put_raw(gsfix_page* p, const char* text);
void gsfix_put_escaped(gsfix_page* p, const char* text);
void gsfix_put_lines(gsfix_page* p, const char* const* lines);     // until NULL
// A JPEG in base64, at most `side` pixels wide and high; *width and *height (or NULL) get its size.
gsf_result gsfix_put_jpeg(gsfix_page* p, const gsf_image* image, int64_t side, int64_t* width, int64_t* height);
void gsfix_put_head(gsfix_page* p, const char* title); // up to <body>, with the common style
void gsfix_put_legend(gsfix_page* p);                  // colour scale of the error maps
extern const double gsfix_error_white;                 // mean absolute error at the bright end of the error maps

// ---- gsfix_dataset.c ---------------------------------------------------------------

enum { GSFIX_ARTIFACT, GSFIX_CLEAN, GSFIX_DEPTH, GSFIX_ALPHA, GSFIX_FRAME_FILES };

typedef struct gsfix_sequence_frame {
    const char *name, *photo;             // file name without ending; the capture's name of the photo
    const char* files[GSFIX_FRAME_FILES]; // relative to the scene's folder, inside it
    uint64_t digests[GSFIX_FRAME_FILES];  // XXH64
    int reference;                        // is the photo one of those that the splats were trained on?
    double psnr;                          // of the artifact frame against the photo
} gsfix_sequence_frame;

// A manifest in SCENE/sequences/, checked: its paths do not leave the scene's folder, its first and last frame are references.
typedef struct gsfix_sequence {
    const char *scene, *kind, *caption, *cameras;
    int views, index, width, height;
    gsfix_sequence_frame* frames;
    size_t frame_count;
    gsf_json json; // holds the texts
} gsfix_sequence;

gsf_result gsfix_parse_sequence(gsf_context* ctx, const char* name, const char* text, size_t size, gsfix_sequence* out);
void gsfix_free_sequence(gsf_context* ctx, gsfix_sequence* sequence);

typedef struct gsfix_scene_sequence { const char* file; uint64_t digest; size_t frames; double psnr; } gsfix_scene_sequence;

typedef struct gsfix_scene_manifest { // SCENE/manifest.json, checked likewise
    const char* name;
    const gsf_json_value* settings;
    gsfix_scene_sequence* sequences;
    size_t sequence_count;
    gsf_json json;
} gsfix_scene_manifest;

gsf_result gsfix_parse_scene_manifest(gsf_context* ctx, const char* name, const char* text, size_t size,
                                      gsfix_scene_manifest* out);
void gsfix_free_scene_manifest(gsf_context* ctx, gsfix_scene_manifest* manifest);

int gsfix_run_dataset(gsfix_app* app);

// A scene of the dataset inside another command, which sets the options before.
typedef struct gsfix_dataset_plan gsfix_dataset_plan;
int gsfix_make_dataset_plan(gsfix_app* app, gsfix_dataset_plan** out); // from the options; 0 or an exit code
void gsfix_destroy_dataset_plan(gsfix_app* app, gsfix_dataset_plan* plan);
// Writes the scene's folder into o.out, which it claims and opens.
gsf_result gsfix_make_dataset_scene(gsfix_app* app, const gsfix_dataset_plan* plan, const char* name, const char* path);
int gsfix_has_dataset_scene(gsfix_app* app, const gsfix_dataset_plan* plan); // is o.out complete and made with these settings?
gsf_result gsfix_load_sequence(gsf_context* ctx, gsfix_path path, gsfix_sequence* out);
gsf_result gsfix_load_scene_manifest(gsf_context* ctx, const char* path, gsfix_scene_manifest* out);
// Parses numbers of views of at least 2, separated by commas; 0 or an exit code.
int gsfix_parse_views(gsfix_app* app, const char* text, int views[16], int* count);
int gsfix_is_manifest(const char* path); // does the file begin as a manifest of this command does?
// For `gsfix info`: the manifest of a sequence or of a scene; checks the digests of all its files.
gsf_result gsfix_info_dataset(gsfix_app* app, const char* path);

// ---- gsfix_evaluate.c ----------------------------------------------------------------

int gsfix_run_evaluate(gsfix_app* app);

#endif
