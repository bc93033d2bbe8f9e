// gsfix_evaluate.h - what the files of the command evaluate share
// SPDX-License-Identifier: MIT
#ifndef GSFIX_EVALUATE_H
#define GSFIX_EVALUATE_H

#include "gsfix.h"

enum { EVAL_LIST = 16, EVAL_SCORES = 8, EVAL_PICTURES = 24 };
typedef enum eval_kind { EVAL_RECONSTRUCTION, EVAL_ARTIFACTS, EVAL_RESTORATION } eval_kind;
enum { EVAL_TABLE_RESTORATION = 1, EVAL_TABLE_RECONSTRUCTION = 2, EVAL_TABLE_CONDITIONS = 4, EVAL_TABLE_TRAJECTORIES = 8 };

typedef struct eval_arm { // a row of the tables
    char name[32];        // in tables and in names of tasks: plain, none, warp, dit ...
    const char* restorer; // NULL: none
    int plain;            // without regularisers
} eval_arm;

typedef struct eval_score { // a column of the tables, in the paper's order
    const char *metric, *title; // name of gsfix metrics; the paper's
    int digits, lower_is_better, of_clip;
} eval_score;
extern const eval_score eval_scores[EVAL_SCORES];

typedef struct eval_run { // a task
    eval_kind kind;
    int scene, views, seed; // seed: 0 for the first one
    int init, arm, trajectory, condition; // indices into the plan's lists, -1: does not apply
    int done;               // has its result been read?
    double scores[EVAL_SCORES]; // NaN: not measured
} eval_run;

typedef struct eval_list { const char* items[EVAL_LIST]; int count; } eval_list;

typedef struct eval_plan {
    gsfix_options given; // as on the command line
    char* texts;         // of the lists
    char** scenes;
    int scene_count, tables, view_counts, views[EVAL_LIST];
    eval_arm arms[EVAL_LIST + 1]; // the last one: the artifacts themselves
    int arm_count, artifacts;     // artifacts: index of that one
    eval_list inits, trajectories, conditions;
    int main_trajectory, main_condition; // of the tables that do not compare them
    char which[256]; // metrics, separated by commas
    eval_run* runs;
    char** names;
    size_t* needs;
    size_t run_count, measured, missing; // runs with and without a result; artifacts have none of their own
} eval_plan;

// The run with these settings, whose scene and seed are added to `like`.
const eval_run* eval_find(const eval_plan* plan, const eval_run* like, int scene, int seed);

typedef struct eval_sequences { // of a scene's folder that gsfix dataset has written
    gsfix_path folder;
    gsfix_sequence* items;
    size_t count;
    uint64_t digest; // of the scene's manifest
} eval_sequences;
gsfix_path eval_artifacts_folder(const eval_plan* plan, const eval_run* run); // of a restoration
gsf_result eval_load_sequences(gsf_context* ctx, gsfix_path folder, eval_sequences* out);
void eval_free_sequences(gsf_context* ctx, eval_sequences* s);
gsfix_path eval_frame_name(size_t sequence, const gsfix_sequence_frame* frame); // of a restored frame in its task's folder

void eval_name_arm(const eval_arm* arm, eval_kind kind, char* to, size_t size); // what a row of ours is called

gsf_result eval_write_tables(gsfix_app* app, const eval_plan* plan);  // gsfix_tables.c: tables.md, tables.tex, tables.csv
gsf_result eval_write_gallery(gsfix_app* app, const eval_plan* plan); // gsfix_gallery.c: gallery.html

#endif
