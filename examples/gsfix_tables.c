// gsfix_tables.c - the tables of gsfix evaluate, in the paper's order, as Markdown, LaTeX and CSV
// SPDX-License-Identifier: MIT
#include "gsfix_evaluate.h"
#include "gsfix_paper.h"

#include <math.h>
#include <stdarg.h>

enum { TABLE_COLUMNS = 72, TABLE_NAME = 96 };

typedef struct table_column {
    char group[TABLE_NAME], name[24]; // columns that follow each other in one group have a common heading; "": none
    int digits, lower_is_better;
} table_column;

typedef struct table_row {
    char name[TABLE_NAME], note[48];   // note: start, or where the figures come from
    int of_paper, is_mean;             // is_mean: the last row of a table of scenes
    int scenes;                        // that the means are over
    double mean[TABLE_COLUMNS], error[TABLE_COLUMNS]; // NaN: none
} table_row;

typedef struct table {
    char id[TABLE_NAME], title[160];
    const char *first, *second; // headings of the columns of names and notes; second NULL: no notes
    table_column columns[TABLE_COLUMNS];
    int column_count;
    table_row* rows;
    size_t row_count, room;
} table;

typedef struct tables {
    gsfix_app* app;
    gsf_context* ctx;
    const eval_plan* plan;
    gsf_buffer md, tex, csv;
    gsf_result result;
} tables;

// ---- figures -------------------------------------------------------------------------

typedef struct figure { double mean, error; int scenes; } figure;

static int seeds_of(const eval_plan* plan) { return plan->given.seeds ? plan->given.seeds : 1; }

// Mean of a score over the scenes for which all seeds have it, and its standard error over the seeds. scene -1: all.
static figure measure_runs(const eval_plan* plan, const eval_run* like, int scene, int score) {
    const int seeds = seeds_of(plan);
    double sum = 0.0, squares = 0.0;
    figure f = {NAN, NAN, 0};
    for (int seed = 0; seed < seeds; seed++) {
        double of_seed = 0.0;
        f.scenes = 0;
        for (int k = 0; k < plan->scene_count; k++) {
            double value = 0.0;
            int whole = scene < 0 || k == scene;
            for (int i = 0; i < seeds && whole; i++) {
                const eval_run* run = eval_find(plan, like, k, i);
                whole = run && run->done && !isnan(run->scores[score]);
                if (whole && i == seed) value = run->scores[score];
            }
            if (whole) of_seed += value, f.scenes++;
        }
        if (!f.scenes) return f;
        of_seed /= f.scenes;
        const double from_mean = of_seed - sum; // Welford's update: sum is the mean so far
        sum += from_mean / (seed + 1);
        squares += from_mean * (of_seed - sum);
    }
    f.mean = sum;
    if (seeds > 1) f.error = sqrt(squares / (seeds - 1) / seeds);
    return f;
}

// ---- building --------------------------------------------------------------------------

static void copy_name(char* to, size_t size, const char* format, ...) GSF_PRINTF(3, 4);
static void copy_name(char* to, size_t size, const char* format, ...) {
    va_list args;
    va_start(args, format);
    vsnprintf(to, size, format, args);
    va_end(args);
}

static void add_column(table* t, const char* group, const char* name, int score) {
    table_column* c = &t->columns[t->column_count++];
    copy_name(c->group, sizeof c->group, "%s", group);
    copy_name(c->name, sizeof c->name, "%s", name);
    c->digits = eval_scores[score].digits;
    c->lower_is_better = eval_scores[score].lower_is_better;
}

static table_row* add_row(tables* w, table* t, const char* name, const char* note) { // NULL: out of memory
    static table_row spare;
    if (w->result == GSF_OK) w->result = gsfix_grow(w->ctx, (void**)&t->rows, &t->room, t->row_count, sizeof *t->rows);
    table_row* row = w->result == GSF_OK ? &t->rows[t->row_count++] : &spare;
    memset(row, 0, sizeof *row);
    copy_name(row->name, sizeof row->name, "%s", name);
    copy_name(row->note, sizeof row->note, "%s", note ? note : "");
    for (int c = 0; c < TABLE_COLUMNS; c++) row->mean[c] = row->error[c] = NAN;
    return row;
}

static void set_cell(table_row* row, int column, figure f) {
    row->mean[column] = f.mean;
    row->error[column] = f.error;
    if (f.scenes && (!row->scenes || f.scenes < row->scenes)) row->scenes = f.scenes;
}

void eval_name_arm(const eval_arm* arm, eval_kind kind, char* to, size_t size) {
    if (arm->plain) copy_name(to, size, "3DGS (plain)");
    else if (strcmp(arm->name, "artifacts") == 0) copy_name(to, size, "Artifact");
    else if (!arm->restorer) copy_name(to, size, "3DGS, regularised (none)");
    else copy_name(to, size, kind == EVAL_RECONSTRUCTION ? "repaired by %s" : "restored by %s", arm->name);
}

static const char* start_of(const eval_plan* plan, int init) { return init >= 0 ? plan->inits.items[init] : "tracks"; }

static int is_benchmark(const eval_plan* plan, const char* name) {
    return plan->given.benchmark && strcmp(plan->given.benchmark, name) == 0;
}

// The paper's figures for a scene of ours, or NULL. DL3DV's names are compared up to the paper's ten digits.
static const paper_scene* find_scene(const char* name, const paper_scene* list, size_t count) {
    for (size_t i = 0; i < count; i++)
        if (strncmp(list[i].name, name, strlen(list[i].name)) == 0 &&
            (strlen(list[i].name) == 10 || strlen(list[i].name) == strlen(name)))
            return &list[i];
    return NULL;
}

typedef struct paper_table { // what the paper prints for a table
    const paper_row* rows;
    size_t row_count;
    const paper_scene* scenes;
    const char* const* methods; // of scenes
    size_t scene_count;
    int method_count;
} paper_table;

static paper_table paper_of(const eval_plan* plan, int reconstruction) {
    static const paper_table none = {NULL, 0, NULL, NULL, 0, 0};
    const paper_table restoration = {
        paper_restoration, sizeof paper_restoration / sizeof *paper_restoration, paper_restoration_scenes,
        paper_restoration_methods, sizeof paper_restoration_scenes / sizeof *paper_restoration_scenes, 4};
    const paper_table dl3dv = {paper_dl3dv, sizeof paper_dl3dv / sizeof *paper_dl3dv, paper_dl3dv_scenes,
                               paper_reconstruction_methods, sizeof paper_dl3dv_scenes / sizeof *paper_dl3dv_scenes, 3};
    const paper_table mip = {
        paper_mipnerf360, sizeof paper_mipnerf360 / sizeof *paper_mipnerf360, paper_mipnerf360_scenes,
        paper_reconstruction_methods, sizeof paper_mipnerf360_scenes / sizeof *paper_mipnerf360_scenes, 3};
    if (is_benchmark(plan, "dl3dv")) return reconstruction ? dl3dv : restoration;
    return is_benchmark(plan, "mipnerf360") && reconstruction ? mip : none;
}

// How many of our scenes the paper has figures for, each counted once.
static int known_scenes(const eval_plan* plan, const paper_table* p) {
    int known = 0;
    for (int i = 0; i < plan->scene_count; i++) known += find_scene(plan->scenes[i], p->scenes, p->scene_count) != NULL;
    return known;
}

// Printed means stand beside ours if they are over the same scenes.
static int is_whole(const eval_plan* plan, const paper_table* p) {
    return p->rows && (size_t)plan->scene_count == p->scene_count && known_scenes(plan, p) == plan->scene_count;
}

// Copies a printed row of a table with groups of 3, 6 and 9 views to the columns for --views.
static void set_printed(const eval_plan* plan, table_row* row, const paper_row* from, int by_views, int columns) {
    static const int printed[] = {3, 6, 9};
    row->of_paper = 1;
    if (!by_views)
        for (int c = 0; c < columns; c++) row->mean[c] = from->values[c];
    for (int s = 0; by_views && s < 3; s++)
        for (int k = 0; k < plan->view_counts; k++)
            for (int v = 0; v < 3; v++)
                if (printed[v] == plan->views[k]) row->mean[s * plan->view_counts + k] = from->values[3 * s + v];
}

// A method's mean over our scenes from the figures per scene, where the paper knows all of them but its means are over more.
static void add_same_scenes(tables* w, table* t, const paper_table* p, int method, int by_views) {
    const eval_plan* plan = w->plan;
    static const int printed[] = {3, 6, 9};
    if (!p->scenes || is_whole(plan, p) || known_scenes(plan, p) != plan->scene_count) return;
    table_row* row = add_row(w, t, p->methods[method], "paper, same scenes");
    row->of_paper = 1;
    for (int s = 0; s < 3; s++)
        for (int k = 0; k < (by_views ? plan->view_counts : 1); k++)
            for (int v = 0; v < (by_views ? 3 : 1); v++) {
                double sum = 0.0;
                if (by_views && printed[v] != plan->views[k]) continue;
                for (int i = 0; i < plan->scene_count; i++) {
                    const paper_scene* scene = find_scene(plan->scenes[i], p->scenes, p->scene_count);
                    sum += scene->values[3 * (v * p->method_count + method) + s];
                }
                row->mean[by_views ? s * plan->view_counts + k : s] = sum / plan->scene_count;
            }
}

static void add_printed(tables* w, table* t, const paper_table* p, const char* only, const char* except, int by_views) {
    const int whole = is_whole(w->plan, p);
    for (size_t i = 0; i < p->row_count && whole; i++) {
        if (only ? strcmp(p->rows[i].name, only) != 0 : strcmp(p->rows[i].name, except) == 0) continue;
        set_printed(w->plan, add_row(w, t, p->rows[i].name, "paper"), &p->rows[i], by_views, EVAL_SCORES);
    }
    for (int m = 0; m < p->method_count; m++)
        if (only ? strcmp(p->methods[m], only) == 0 : strcmp(p->methods[m], except) != 0) add_same_scenes(w, t, p, m, by_views);
}

// ---- writing ---------------------------------------------------------------------------

static int is_best(const table* t, size_t row, int column) { // among the rows measured here, at least two
    const table_row* r = &t->rows[row];
    int rivals = 0;
    if (r->of_paper || isnan(r->mean[column])) return 0;
    for (size_t i = 0; i < t->row_count; i++) {
        const table_row* other = &t->rows[i];
        if (i == row || other->of_paper || isnan(other->mean[column])) continue;
        if (t->columns[column].lower_is_better ? other->mean[column] < r->mean[column] : other->mean[column] > r->mean[column])
            return 0;
        rivals++;
    }
    return rivals > 0;
}

static int compares_rows(const table* t) { return !t->rows[t->row_count - 1].is_mean; } // else the rows are scenes

static void put_latex(gsf_context* ctx, gsf_buffer* to, const char* text) {
    for (; *text; text++) {
        if (strchr("_%&#$", *text)) gsf_append_bytes(ctx, to, "\\", 1);
        gsf_append_bytes(ctx, to, text, 1);
    }
}

static void put_figure(tables* w, gsf_buffer* to, const table* t, size_t row, int column, int latex) {
    const double mean = t->rows[row].mean[column], error = t->rows[row].error[column];
    const int digits = t->columns[column].digits, best = compares_rows(t) && is_best(t, row, column);
    if (isnan(mean)) {
        gsf_append_text(w->ctx, to, latex ? "--" : "–");
        return;
    }
    gsf_append_text(w->ctx, to, best ? latex ? "\\textbf{%.*f}" : "**%.*f**" : "%.*f", digits, mean);
    if (!isnan(error)) gsf_append_text(w->ctx, to, latex ? "\\,{\\scriptsize$\\pm$%.*f}" : " ± %.*f", digits, error);
}

static void write_markdown(tables* w, const table* t) {
    gsf_context* ctx = w->ctx;
    gsf_buffer* md = &w->md;
    gsf_append_text(ctx, md, "\n## %s\n\n| %s |", t->title, t->first);
    if (t->second) gsf_append_text(ctx, md, " %s |", t->second);
    for (int c = 0; c < t->column_count; c++) {
        const table_column* column = &t->columns[c];
        gsf_append_text(ctx, md, " %s%s%s %s |", column->group, *column->group ? ", " : "", column->name,
                        column->lower_is_better ? "↓" : "↑");
    }
    gsf_append_text(ctx, md, "\n|---|%s", t->second ? "---|" : "");
    for (int c = 0; c < t->column_count; c++) gsf_append_text(ctx, md, "---:|");
    gsf_append_text(ctx, md, "\n");
    for (size_t i = 0; i < t->row_count; i++) {
        const table_row* row = &t->rows[i];
        gsf_append_text(ctx, md, "| %s |", row->name);
        if (t->second) gsf_append_text(ctx, md, " %s |", row->note);
        for (int c = 0; c < t->column_count; c++) {
            gsf_append_text(ctx, md, " ");
            put_figure(w, md, t, i, c, 0);
            gsf_append_text(ctx, md, " |");
        }
        gsf_append_text(ctx, md, "\n");
    }
}

static void write_latex(tables* w, const table* t) {
    gsf_context* ctx = w->ctx;
    gsf_buffer* tex = &w->tex;
    int groups = 0;
    gsf_append_text(ctx, tex, "\n\\begin{table}[t]\n\\centering\n\\resizebox{0.95\\linewidth}{!}{\n\\begin{tabular}{l%s",
                    t->second ? "l" : "");
    for (int c = 0; c < t->column_count; c++) {
        const int fresh = c == 0 || strcmp(t->columns[c].group, t->columns[c - 1].group) != 0;
        groups |= *t->columns[c].group != 0;
        gsf_append_text(ctx, tex, fresh || !*t->columns[c].group ? "|c" : "c");
    }
    gsf_append_text(ctx, tex, "}\n");
    for (int c = 0; groups && c < t->column_count;) {
        int n = 1;
        while (c + n < t->column_count && strcmp(t->columns[c + n].group, t->columns[c].group) == 0) n++;
        if (c == 0) gsf_append_text(ctx, tex, "%s", t->second ? "& " : "");
        gsf_append_text(ctx, tex, "& \\multicolumn{%d}{c%s}{", n, c + n < t->column_count ? "|" : "");
        put_latex(ctx, tex, t->columns[c].group);
        gsf_append_text(ctx, tex, "} ");
        c += n;
    }
    if (groups) gsf_append_text(ctx, tex, "\\\\\n");
    put_latex(ctx, tex, t->first);
    if (t->second) gsf_append_text(ctx, tex, " & %s", t->second);
    for (int c = 0; c < t->column_count; c++) {
        gsf_append_text(ctx, tex, " & ");
        put_latex(ctx, tex, t->columns[c].name);
        gsf_append_text(ctx, tex, " $\\%s$", t->columns[c].lower_is_better ? "downarrow" : "uparrow");
    }
    gsf_append_text(ctx, tex, " \\\\ \\hline\n");
    for (size_t i = 0; i < t->row_count; i++) {
        if (t->rows[i].is_mean) gsf_append_text(ctx, tex, "\\hline\n");
        put_latex(ctx, tex, t->rows[i].name);
        if (t->second) gsf_append_text(ctx, tex, " & "), put_latex(ctx, tex, t->rows[i].note);
        for (int c = 0; c < t->column_count; c++) {
            gsf_append_text(ctx, tex, " & ");
            put_figure(w, tex, t, i, c, 1);
        }
        gsf_append_text(ctx, tex, " \\\\\n");
    }
    gsf_append_text(ctx, tex, "\\end{tabular}\n}\n\\caption{");
    put_latex(ctx, tex, t->title);
    gsf_append_text(ctx, tex, ".}\n\\label{tab:%s}\n\\end{table}\n", t->id);
}

static void put_csv(gsf_context* ctx, gsf_buffer* to, const char* text) { // quoted if need be
    const int quoted = strpbrk(text, ",\"") != NULL;
    if (quoted) gsf_append_bytes(ctx, to, "\"", 1);
    for (; *text; text++) gsf_append_bytes(ctx, to, *text == '"' ? "\"\"" : text, *text == '"' ? 2 : 1);
    if (quoted) gsf_append_bytes(ctx, to, "\"", 1);
}

static void write_csv(tables* w, const table* t) { // a line per figure, with all digits
    gsf_context* ctx = w->ctx;
    gsf_buffer* csv = &w->csv;
    for (size_t i = 0; i < t->row_count; i++)
        for (int c = 0; c < t->column_count; c++) {
            const table_row* row = &t->rows[i];
            const char* const texts[] = {t->id, row->name, row->note, t->columns[c].group, t->columns[c].name};
            if (isnan(row->mean[c])) continue;
            for (int k = 0; k < 5; k++) {
                put_csv(ctx, csv, texts[k]);
                gsf_append_text(ctx, csv, ",");
            }
            gsf_append_text(ctx, csv, "%s,%.6f", row->of_paper ? "paper" : "gsfix", row->mean[c]);
            gsf_append_text(ctx, csv, isnan(row->error[c]) ? "," : ",%.6f", row->error[c]);
            gsf_append_text(ctx, csv, row->scenes ? ",%d\n" : ",\n", row->scenes);
        }
}

// Columns without any figure: of metrics that were not measured.
static void drop_empty_columns(table* t) {
    int kept = 0;
    for (int c = 0; c < t->column_count; c++) {
        int any = 0;
        for (size_t i = 0; i < t->row_count; i++) {
            table_row* row = &t->rows[i];
            any |= !isnan(row->mean[c]);
            row->mean[kept] = row->mean[c];
            row->error[kept] = row->error[c];
        }
        t->columns[kept] = t->columns[c];
        kept += any;
    }
    t->column_count = kept;
}

static void end_table(tables* w, table* t) {
    drop_empty_columns(t);
    for (size_t i = 0; i < t->row_count; i++) {
        table_row* row = &t->rows[i];
        const size_t n = strlen(row->name);
        if (!row->of_paper && row->scenes && row->scenes < w->plan->scene_count && w->plan->missing && compares_rows(t))
            copy_name(row->name + n, sizeof row->name - n, " (%d of %d scenes)", row->scenes, w->plan->scene_count);
    }
    if (t->column_count && w->result == GSF_OK) {
        write_markdown(w, t);
        write_latex(w, t);
        write_csv(w, t);
    }
    gsf_free(w->ctx, t->rows);
}

static void begin_table(table* t, const char* id, const char* first, const char* second) {
    memset(t, 0, sizeof *t);
    copy_name(t->id, sizeof t->id, "%s", id);
    t->first = first;
    t->second = second;
}

// ---- restoration, and its ablation ---------------------------------------------------------

static eval_run like_restoration(const eval_plan* plan, int arm, int condition) {
    eval_run like;
    memset(&like, 0, sizeof like);
    like.kind = EVAL_RESTORATION;
    like.views = plan->views[0];
    like.arm = arm;
    like.init = like.trajectory = -1;
    like.condition = condition;
    return like;
}

static int is_dit(const eval_plan* plan, int arm) {
    return plan->arms[arm].restorer && strncmp(plan->arms[arm].restorer, "dit:", 4) == 0;
}

static void add_restoration_columns(table* t) {
    for (int s = 0; s < EVAL_SCORES; s++) add_column(t, "", eval_scores[s].title, s);
}

static void add_restoration_row(tables* w, table* t, const char* name, const eval_run* like) {
    table_row* row = add_row(w, t, name, "tracks");
    for (int s = 0; s < EVAL_SCORES; s++) set_cell(row, s, measure_runs(w->plan, like, -1, s));
}

static void write_restoration(tables* w) {
    const eval_plan* plan = w->plan;
    const paper_table p = paper_of(plan, 0);
    char name[TABLE_NAME];
    eval_run like = like_restoration(plan, plan->artifacts, -1);
    table t;
    begin_table(&t, "restoration", "sequences", "start");
    copy_name(t.title, sizeof t.title, "Restoration of sequences, %d views%s", plan->views[0],
              is_benchmark(plan, "dl3dv") ? " (DL3DV-Res)" : "");
    add_restoration_columns(&t);
    add_printed(w, &t, &p, "Artifact", NULL, 0);
    add_restoration_row(w, &t, "Artifact", &like);
    add_printed(w, &t, &p, NULL, "Artifact", 0);
    for (int arm = 0; arm < plan->arm_count; arm++) {
        if (!plan->arms[arm].restorer) continue;
        eval_name_arm(&plan->arms[arm], EVAL_RESTORATION, name, sizeof name);
        like = like_restoration(plan, arm, is_dit(plan, arm) ? plan->main_condition : -1);
        add_restoration_row(w, &t, name, &like);
    }
    end_table(w, &t);
}

static void write_conditions(tables* w) { // rows in the paper's order, which has none without any tokens
    static const struct { const char *condition, *name; } rows[] = {
        {"none", "without tokens"}, {"2d", "w/o 3D tokens"}, {"3d", "w/o 2D tokens"}, {"both", "full model"}};
    const eval_plan* plan = w->plan;
    const paper_table p = paper_of(plan, 0);
    char name[TABLE_NAME];
    table t;
    begin_table(&t, "conditions", "model", "start");
    copy_name(t.title, sizeof t.title, "Ablation of conditions: restoration of sequences, %d views", plan->views[0]);
    add_restoration_columns(&t);
    for (int k = 0; k < 4; k++) {
        if (k > 0 && is_whole(plan, &p))
            set_printed(plan, add_row(w, &t, paper_conditions[k - 1].name, "paper"), &paper_conditions[k - 1], 0, EVAL_SCORES);
        for (int arm = 0; arm < plan->arm_count; arm++)
            for (int c = 0; c < plan->conditions.count; c++) {
                if (!is_dit(plan, arm) || strcmp(plan->conditions.items[c], rows[k].condition) != 0) continue;
                const eval_run like = like_restoration(plan, arm, c);
                copy_name(name, sizeof name, "%s %s", plan->arms[arm].name, rows[k].name);
                add_restoration_row(w, &t, name, &like);
            }
    }
    end_table(w, &t);
}

// Columns of a table of scenes: PSNR, SSIM, LPIPS of each method, the paper's first.
static void add_method_columns(table* t, const char* method) {
    for (int s = 0; s < 3; s++) add_column(t, method, eval_scores[s].title, s);
}

static void set_scene_means(table* t, int scene_count) { // of the paper's columns, over the rows that have them all
    table_row* mean = &t->rows[t->row_count - 1];
    for (int c = 0; c < t->column_count; c++) {
        double sum = 0.0;
        for (int i = 0; i < scene_count; i++) sum += t->rows[i].mean[c]; // NaN if one is missing
        if (isnan(mean->mean[c])) mean->mean[c] = sum / scene_count;
    }
}

// One row per scene, then the mean; methods: the runs to show and their headings.
static void write_scenes(tables* w, table* t, const paper_table* p, int views, const eval_run* methods, int count) {
    const eval_plan* plan = w->plan;
    const int known = p->scenes && known_scenes(plan, p), group = views == 6 ? 1 : views == 9 ? 2 : 0;
    const int shown = known && (group || views == 3) ? p->method_count : 0;
    char name[TABLE_NAME];
    for (int m = 0; m < shown; m++) {
        copy_name(name, sizeof name, "%s (paper)", p->methods[m]);
        add_method_columns(t, name);
    }
    for (int m = 0; m < count; m++) {
        if (t->column_count + 3 > TABLE_COLUMNS) break;
        eval_name_arm(&plan->arms[methods[m].arm], methods[m].kind, name, sizeof name);
        add_method_columns(t, name);
    }
    for (int i = 0; i <= plan->scene_count && w->result == GSF_OK; i++) {
        const int is_mean = i == plan->scene_count;
        const paper_scene* printed = !shown || is_mean ? NULL : find_scene(plan->scenes[i], p->scenes, p->scene_count);
        table_row* row = add_row(w, t, is_mean ? "average" : plan->scenes[i], NULL);
        row->is_mean = is_mean;
        for (int c = 0; printed && c < 3 * shown; c++) row->mean[c] = printed->values[3 * group * p->method_count + c];
        for (int c = 3 * shown; c < t->column_count; c++)
            set_cell(row, c, measure_runs(plan, &methods[c / 3 - shown], is_mean ? -1 : i, c % 3));
    }
    if (w->result == GSF_OK) set_scene_means(t, plan->scene_count);
}

static void write_restoration_scenes(tables* w) {
    const eval_plan* plan = w->plan;
    const paper_table p = paper_of(plan, 0);
    eval_run methods[EVAL_LIST + 1];
    int count = 0;
    table t;
    methods[count++] = like_restoration(plan, plan->artifacts, -1);
    for (int arm = 0; arm < plan->arm_count; arm++)
        if (plan->arms[arm].restorer)
            methods[count++] = like_restoration(plan, arm, is_dit(plan, arm) ? plan->main_condition : -1);
    begin_table(&t, "restoration-scenes", "scene", NULL);
    copy_name(t.title, sizeof t.title, "Restoration per scene, %d views", plan->views[0]);
    write_scenes(w, &t, &p, 3, methods, count);
    end_table(w, &t);
}

// ---- reconstruction, and its ablation --------------------------------------------------------

static eval_run like_reconstruction(const eval_plan* plan, int views, int init, int arm, int trajectory) {
    eval_run like;
    memset(&like, 0, sizeof like);
    like.kind = EVAL_RECONSTRUCTION;
    like.views = views;
    like.init = init;
    like.arm = arm;
    like.trajectory = plan->arms[arm].restorer ? trajectory : -1;
    like.condition = is_dit(plan, arm) ? plan->main_condition : -1;
    return like;
}

static void add_reconstruction_row(tables* w, table* t, int arm, int init) {
    const eval_plan* plan = w->plan;
    char name[TABLE_NAME];
    eval_name_arm(&plan->arms[arm], EVAL_RECONSTRUCTION, name, sizeof name);
    table_row* row = add_row(w, t, name, start_of(plan, init));
    for (int s = 0; s < 3; s++)
        for (int k = 0; k < plan->view_counts; k++) {
            const eval_run like = like_reconstruction(plan, plan->views[k], init, arm, plan->main_trajectory);
            set_cell(row, s * plan->view_counts + k, measure_runs(plan, &like, -1, s));
        }
}

static void write_reconstruction(tables* w) {
    const eval_plan* plan = w->plan;
    const paper_table p = paper_of(plan, 1);
    char views[24];
    table t;
    begin_table(&t, "reconstruction", "method", "start");
    copy_name(t.title, sizeof t.title, "Reconstruction from few views%s",
              is_benchmark(plan, "dl3dv")        ? " (DL3DV-Benchmark)"
              : is_benchmark(plan, "mipnerf360") ? " (Mip-NeRF 360)"
                                                 : "");
    for (int s = 0; s < 3; s++)
        for (int k = 0; k < plan->view_counts; k++) {
            copy_name(views, sizeof views, "%d-view", plan->views[k]);
            add_column(&t, eval_scores[s].title, views, s);
        }
    for (int repaired = 0; repaired < 2; repaired++) { // as in the paper: the rivals stand between plain 3DGS and the repaired
        if (repaired) add_printed(w, &t, &p, NULL, "3DGS", 1);
        else add_printed(w, &t, &p, "3DGS", NULL, 1);
        for (int arm = 0; arm < plan->arm_count; arm++)
            for (int init = 0; init < plan->inits.count; init++)
                if ((plan->arms[arm].restorer != NULL) == repaired) add_reconstruction_row(w, &t, arm, init);
    }
    end_table(w, &t);
}

static void write_reconstruction_scenes(tables* w) {
    const eval_plan* plan = w->plan;
    const paper_table p = paper_of(plan, 1);
    for (int k = 0; k < plan->view_counts; k++)
        for (int init = 0; init < plan->inits.count; init++) {
            const int views = plan->views[k];
            eval_run methods[EVAL_LIST];
            table t;
            for (int arm = 0; arm < plan->arm_count; arm++)
                methods[arm] = like_reconstruction(plan, views, init, arm, plan->main_trajectory);
            begin_table(&t, gsfix_pathf("reconstruction-scenes-%d-%s", views, start_of(plan, init)).s, "scene", NULL);
            copy_name(t.title, sizeof t.title, "Reconstruction per scene, %d views, start %s", views, start_of(plan, init));
            write_scenes(w, &t, &p, views, methods, plan->arm_count);
            end_table(w, &t);
        }
}

static void write_trajectories(tables* w) { // rows in the paper's order
    static const struct { const char *trajectory, *name; } rows[] = {
        {"interpolate", "Interpolation trajectory"}, {"ellipse", "Ellipse trajectory"},
        {"reference", "Reference-guided trajectory"}};
    const eval_plan* plan = w->plan;
    const paper_table p = paper_of(plan, 1);
    const int printed = is_benchmark(plan, "mipnerf360") && is_whole(plan, &p) && plan->views[0] == 3;
    char name[TABLE_NAME];
    table t;
    begin_table(&t, "trajectories", "trajectory", "start");
    copy_name(t.title, sizeof t.title, "Ablation of trajectories, %d views%s", plan->views[0],
              is_benchmark(plan, "mipnerf360") ? " (Mip-NeRF 360)" : "");
    for (int s = 0; s < 3; s++) add_column(&t, "", eval_scores[s].title, s);
    for (int k = 0; k < 3; k++) {
        if (printed) set_printed(plan, add_row(w, &t, paper_trajectories[k].name, "paper"), &paper_trajectories[k], 0, 3);
        for (int arm = 0; arm < plan->arm_count; arm++)
            for (int init = 0; init < plan->inits.count; init++)
                for (int c = 0; c < plan->trajectories.count; c++) {
                    if (!plan->arms[arm].restorer || strcmp(plan->trajectories.items[c], rows[k].trajectory) != 0) continue;
                    const eval_run like = like_reconstruction(plan, plan->views[0], init, arm, c);
                    copy_name(name, sizeof name, "%s, %s", rows[k].name, plan->arms[arm].name);
                    table_row* row = add_row(w, &t, name, start_of(plan, init));
                    for (int s = 0; s < 3; s++) set_cell(row, s, measure_runs(plan, &like, -1, s));
                }
    }
    end_table(w, &t);
}

// ---- all of them ---------------------------------------------------------------------------

static void write_introduction(tables* w) {
    const eval_plan* plan = w->plan;
    gsf_context* ctx = w->ctx;
    gsf_buffer* md = &w->md;
    const int seeds = seeds_of(plan);
    const gsfix_options* o = &plan->given;
    gsf_append_text(ctx, md, "# Evaluation\n\n%d scene%s (", plan->scene_count, plan->scene_count == 1 ? "" : "s");
    for (int i = 0; i < plan->scene_count; i++) gsf_append_text(ctx, md, "%s%s", i ? ", " : "", plan->scenes[i]);
    gsf_append_text(ctx, md, "), %d seed%s from %llu.", seeds, seeds == 1 ? "" : "s", (unsigned long long)o->seed);
    if (seeds > 1) gsf_append_text(ctx, md, " Figures are means ± their standard errors over the seeds.");
    gsf_append_text(ctx, md,
                    " Arrows say whether more or less is better; the best of the rows measured here is bold. *Start* names the "
                    "initial points; *tracks* are those that the papers use.\n\nReconstruction: splats trained on K photos; every "
                    "%s photo by name is held out and measured, per photo, then per scene.", o->test_every ? gsfix_pathf("%dth", o->test_every).s : "8th");
    if (plan->tables & (EVAL_TABLE_RESTORATION | EVAL_TABLE_CONDITIONS))
        gsf_append_text(ctx, md,
                        " Restoration: plain splats of %d photos, rendered along the capture; PSNR, SSIM and LPIPS over the frames "
                        "between these photos, the others over whole sequences.", plan->views[0]);
    gsf_append_text(ctx, md, " SSIM%s defined as in the 3DGS papers.",
                    strstr(plan->which, "lpips") ? " and LPIPS (VGG, images in [0,1]) are" : " is");
    if (o->benchmark)
        gsf_append_text(ctx, md, " Rows named *paper* are printed figures; *paper, same scenes* are means of those printed per "
                                 "scene.");
    if (plan->missing)
        gsf_append_text(ctx, md, "\n\n**%zu of %zu runs are missing**; means are over the scenes whose runs are there.",
                        plan->missing, plan->missing + plan->measured);
    gsf_append_text(ctx, md, "\n");
}

gsf_result eval_write_tables(gsfix_app* app, const eval_plan* plan) {
    gsf_context* ctx = &app->ctx;
    tables w = {app, ctx, plan, {0}, {0}, {0}, GSF_OK};
    gsf_append_text(ctx, &w.csv, "table,row,start,group,column,source,mean,standard_error,scenes\n");
    gsf_append_text(ctx, &w.tex, "%% tables of gsfix evaluate; \\usepackage{graphicx}\n");
    write_introduction(&w);
    if (plan->tables & EVAL_TABLE_RESTORATION) write_restoration(&w);
    if (plan->tables & EVAL_TABLE_RECONSTRUCTION) write_reconstruction(&w);
    if (plan->tables & EVAL_TABLE_CONDITIONS) write_conditions(&w);
    if (plan->tables & EVAL_TABLE_TRAJECTORIES) write_trajectories(&w);
    const int per_scene = plan->scene_count > 1 || plan->given.benchmark; // else they would repeat the others
    if (per_scene && plan->tables & EVAL_TABLE_RESTORATION) write_restoration_scenes(&w);
    if (per_scene && plan->tables & EVAL_TABLE_RECONSTRUCTION) write_reconstruction_scenes(&w);
    gsf_buffer* const files[] = {&w.md, &w.tex, &w.csv};
    static const char* const endings[] = {"md", "tex", "csv"};
    for (int i = 0; i < 3; i++) {
        if (files[i]->failed) w.result = GSF_ERROR_OUT_OF_MEMORY;
        if (w.result == GSF_OK)
            w.result = gsf_write_file(ctx, gsfix_pathf("%s/tables.%s", app->o.out, endings[i]).s, files[i]->data,
                                      files[i]->size);
        gsf_destroy_buffer(ctx, files[i]);
    }
    return w.result;
}
