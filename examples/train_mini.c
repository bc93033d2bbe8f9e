/* train_mini - makes data for the restorer mini from seeds, and trains it
   gcc -O2 -std=c11 -fopenmp -I. examples/train_mini.c -o train_mini -lm
   (with Embree, which traces the rays faster: -DGSF_USE_EMBREE and -lembree3 or -lembree4)

       train_mini OUT.safetensors --data DIR [--scenes 1001-1060] [--check 1061-1064] [--steps 14000 | --quick] [--resume]
           [--batch 8] [--crop 96] [--rate 0.001] [--seed 1] [--save-every 500] [--init FILE] [--threads N] [--make-only]
           [--pixels 216] [--fit 599] [--own FILE] [--groups 1] [--better 0] [--int8]

   --scenes and --check: seeds, such as 1001-1040,1055. DIR gets a file for each (mini_data.h), unless it is there already.
   The network is trained on the former and measured on the latter. OUT: the moving average of the weights, in bfloat16 or,
   with --int8, all kernels in 8-bit integers. OUT.state: what --resume continues from, written every --save-every steps; a
   run that was killed and resumed ends with the same bytes, as do runs with other numbers of threads. --quick: 4000 steps,
   ten minutes on one core. --init starts from the weights of a file. --pixels: longer side of the photos; --fit: step of the
   last round, of which there are three. --own: in half of the scenes that are made, the rounds are restored by the weights of
   FILE, and frames of the splats that result are added. --better: share of the samples whose render is partly the truth; with
   0.2 the network learns to keep what is right, but repairs less. --groups N: the batch is added up in N parts (training.h),
   which up to N ranks share: with -DGSF_USE_MPI, compiled by mpicc,
       mpirun -np 2 train_mini ... --groups 2
   writes the bytes of the same command on one rank. OUT.loss.csv and OUT.loss.html: loss of every step, and its curve. */
#ifndef _POSIX_C_SOURCE
#define _POSIX_C_SOURCE 200809L
#endif
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"
#include "gsfixer_splat.h"

#include "mini_data.h"
#include "mini_batches.h"
#include "training.h"

enum { SEED_RANGES = 16 };
typedef struct seeds { // ranges of them, both ends included
    int ranges;
    uint64_t first[SEED_RANGES], last[SEED_RANGES];
} seeds;

typedef struct options {
    const char *out, *data, *init, *own;
    seeds scenes, check;
    int steps, batch, crop, save_every, threads, resume, make_only, int8, pixels, fit, groups;
    uint64_t seed;
    double rate, better;
} options;

typedef struct training {
    gsf_context ctx;
    options o;
    gsf_nn_weights* files;       // of the scenes, then of those to check
    const gsf_nn_tensor** scenes;
    size_t scene_count, check_count;
    gsf__mini net;
    gsf__nn_params params;
    gsf__mini_run run;
    mini_batch batch;
    gsf__mini_input* inputs;
    float *planes, *truth;       // of all samples of a group
    training_ranks ranks;
    training_sum sum;
    training_log log;
    gsf_restorer own;
} training;

static double decibels(double square) { return -10.0 * log10(square > 1e-10 ? square : 1e-10); }

// ---- data ------------------------------------------------------------------------

static size_t seed_count(const seeds* s) {
    size_t count = 0;
    for (int i = 0; i < s->ranges; i++) count += (size_t)(s->last[i] - s->first[i] + 1);
    return count;
}

static uint64_t seed_at(const seeds* s, size_t index) {
    int i = 0;
    for (; index > s->last[i] - s->first[i]; i++) index -= (size_t)(s->last[i] - s->first[i] + 1);
    return s->first[i] + index;
}

static gsf_result open_scene(training* t, size_t index, uint64_t seed) {
    char path[2048];
    gsf_nn_weights* file = t->files + index;
    snprintf(path, sizeof path, "%s/%llu.safetensors", t->o.data, (unsigned long long)seed);
    struct stat there;
    if (stat(path, &there) != 0 && t->ranks.rank == 0) {
        const data_desc desc = {t->o.data, t->o.pixels, t->o.fit, t->o.own ? &t->own : NULL};
        const gsf_result made = make_data(&t->ctx, &desc, seed, path);
        if (made != GSF_OK) return made;
        fprintf(stderr, "train_mini: scene %llu, %.1f CPU minutes\n", (unsigned long long)seed, training_cpu_minutes());
    }
    const gsf_result result = gsf_nn_load_weights(&t->ctx, path, NULL, file);
    if (result != GSF_OK) return result;
    const gsf_nn_tensor* frames = gsf_nn_find_tensor(file, "frames");
    t->scenes[index] = frames;
    if (frames && frames->dtype == GSF_NN_U8 && frames->rank == 4 && frames->shape[0] > 0 && frames->shape[1] >= t->o.crop &&
        frames->shape[2] >= t->o.crop && frames->shape[3] == DATA_PIXEL)
        return GSF_OK;
    return gsf_fail(&t->ctx, GSF_ERROR_FORMAT, "%s: no frames of at least %d x %d pixels", path, t->o.crop, t->o.crop);
}

static gsf_result open_data(training* t) {
    const gsf_nn_mini_desc own = {.path = t->o.own, .references = DATA_REFERENCES};
    if (t->o.own) {
        const gsf_result result = gsf_nn_make_mini(&t->ctx, &own, &t->own);
        if (result != GSF_OK) return result;
    }
    t->scene_count = seed_count(&t->o.scenes);
    t->check_count = seed_count(&t->o.check);
    const size_t all = t->scene_count + t->check_count;
    t->files = (gsf_nn_weights*)gsf_alloc_zeroed(&t->ctx, all, sizeof *t->files);
    t->scenes = (const gsf_nn_tensor**)gsf_alloc_zeroed(&t->ctx, all, sizeof *t->scenes);
    if (!t->files || !t->scenes) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < all; i++) {
        const uint64_t seed = i < t->scene_count ? seed_at(&t->o.scenes, i) : seed_at(&t->o.check, i - t->scene_count);
        const gsf_result result = open_scene(t, i, seed);
        if (result != GSF_OK) return result;
    }
    return GSF_OK;
}

// ---- training --------------------------------------------------------------------

// A new network, or that of --init; its weights and the optimiser's state are those of OUT.state if the run continues.
static gsf_result open_network(training* t) {
    char first[TRAINING_PATH], state[TRAINING_PATH];
    gsf__mini sizes;
    memset(&sizes, 0, sizeof sizes);
    sizes.hidden = 32;
    sizes.features = sizes.shared = 16;
    for (int l = 0; l < GSF__MINI_LEVELS; l++) {
        sizes.width[l] = l ? 48 : 32;
        sizes.blocks[l] = l > 1 ? 2 : 1;
    }
    snprintf(first, sizeof first, "%s.first%d", t->o.out, t->ranks.rank);
    snprintf(state, sizeof state, "%s.state", t->o.out);
    gsf_result result = t->o.init ? GSF_OK : gsf__mini_make(&t->ctx, &sizes, t->o.seed, first);
    if (result == GSF_OK) result = gsf__mini_open(&t->ctx, t->o.init ? t->o.init : first, NULL, 0, &t->net);
    if (result == GSF_OK) result = gsf__nn_make_params(&t->ctx, &t->net.weights, NULL, 1, &t->params);
    if (result == GSF_OK && t->o.resume) result = gsf__nn_load_params(&t->ctx, &t->params, state);
    if (!t->o.init) remove(first);
    if (result == GSF_OK && t->params.step) result = training_load_log(&t->ctx, t->o.out, t->params.step, &t->log);
    return result;
}

static gsf_result make_batches(training* t) {
    const size_t pixels = (size_t)(t->o.crop * t->o.crop), count = (size_t)(t->o.batch / t->o.groups);
    const size_t planes = GSF__MINI_FRAME + DATA_REFERENCES * GSF__MINI_REFERENCE;
    t->planes = (float*)gsf_alloc(&t->ctx, count * pixels, planes * sizeof(float));
    t->truth = (float*)gsf_alloc(&t->ctx, count * pixels, 3 * sizeof(float));
    t->inputs = (gsf__mini_input*)gsf_alloc_zeroed(&t->ctx, count, sizeof *t->inputs);
    t->batch.samples = (mini_sample*)gsf_alloc_zeroed(&t->ctx, count, sizeof *t->batch.samples);
    if (!t->planes || !t->truth || !t->inputs || !t->batch.samples) return GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) {
        mini_sample* s = t->batch.samples + i;
        s->frame = t->planes + i * pixels * planes;
        s->shown = s->frame + pixels * GSF__MINI_FRAME;
        s->truth = t->truth + 3 * i * pixels;
        t->inputs[i] = (gsf__mini_input){t->o.crop, t->o.crop, DATA_REFERENCES, s->frame, s->shown};
    }
    t->batch.scenes = t->scenes;
    t->batch.scene_count = t->scene_count;
    t->batch.crop = t->o.crop;
    t->batch.count = t->o.batch;
    t->batch.seed = t->o.seed;
    t->batch.better = t->o.better;
    const gsf_result result = training_begin_sum(&t->ctx, t->ranks, t->o.groups, t->params.count, &t->sum);
    if (result != GSF_OK) return result;
    return gsf__mini_begin(&t->ctx, &t->net, t->o.batch / t->o.groups, DATA_REFERENCES, t->o.crop, t->o.crop, 1, &t->run);
}

static gsf_result save_state(training* t) {
    char path[TRAINING_PATH];
    const gsf_result result = training_save_log(&t->ctx, t->o.out, "train_mini", &t->log);
    snprintf(path, sizeof path, "%s.state", t->o.out);
    if (result != GSF_OK) return result;
    return gsf__nn_save_params(&t->ctx, &t->params, GSF__NN_SAVE_STATE, path);
}

typedef struct narrowing { // tensors of floats on their way into a file
    gsf_nn_tensor* tensors;    // that it gets
    size_t count;
    unsigned char *memory, *at; // for their values and names; the next free byte
} narrowing;

static void* narrow_take(narrowing* n, size_t bytes) {
    void* const p = n->at;
    n->at += (bytes + 7) / 8 * 8;
    return p;
}

static void narrow_add(narrowing* n, const gsf_nn_tensor* like, const char* name, gsf_nn_dtype dtype, const void* data) {
    gsf_nn_tensor* t = n->tensors + n->count++;
    *t = *like;
    t->name = name;
    t->dtype = dtype;
    t->data = data;
}

static void narrow_to_bf16(narrowing* n, const gsf_nn_tensor* t, const float* values) {
    uint16_t* to = (uint16_t*)narrow_take(n, (size_t)t->count * sizeof *to);
    for (int64_t i = 0; i < t->count; i++) to[i] = gsf__float_to_bf16(values[i]);
    narrow_add(n, t, t->name, GSF_NN_BF16, to);
}

// 8-bit integers, and a factor per output that makes its largest weight 127.
static void narrow_to_int8(narrowing* n, const gsf_nn_tensor* t, const float* values) {
    const int64_t outputs = t->shape[0], each = t->count / outputs;
    const gsf_nn_tensor factors = gsf_nn_wrap_tensor("", NULL, 1, &outputs);
    const size_t room = strlen(t->name) + sizeof "_scale";
    char* name = (char*)narrow_take(n, room);
    float* scale = (float*)narrow_take(n, (size_t)outputs * sizeof *scale);
    int8_t* to = (int8_t*)narrow_take(n, (size_t)t->count);
    snprintf(name, room, "%s_scale", t->name);
    for (int64_t o = 0; o < outputs; o++, values += each) {
        float most = 0.0f;
        for (int64_t i = 0; i < each; i++) most = fmaxf(most, fabsf(values[i]));
        scale[o] = most / 127.0f;
        for (int64_t i = 0; i < each; i++) to[o * each + i] = (int8_t)(most > 0.0f ? lrintf(values[i] * 127.0f / most) : 0);
    }
    narrow_add(n, t, t->name, GSF_NN_I8, to);
    narrow_add(n, &factors, name, GSF_NN_F32, scale);
}

// The moving average, in bfloat16 or, with --int8, kernels in 8-bit integers.
static gsf_result save_network(training* t) {
    const gsf_nn_weights* w = &t->net.weights;
    narrowing n = {NULL, 0, NULL, NULL};
    n.tensors = (gsf_nn_tensor*)gsf_alloc(&t->ctx, 2 * w->tensor_count, sizeof *n.tensors);
    n.memory = n.at = (unsigned char*)gsf_alloc(&t->ctx, 2 * (size_t)t->params.count + 4096 * w->tensor_count, 1);
    gsf_result result = n.tensors && n.memory ? GSF_OK : GSF_ERROR_OUT_OF_MEMORY;
    for (size_t i = 0; result == GSF_OK && i < w->tensor_count; i++) {
        const float* values = t->params.average + t->params.at[i];
        if (t->o.int8 && w->tensors[i].rank == 4) narrow_to_int8(&n, w->tensors + i, values);
        else narrow_to_bf16(&n, w->tensors + i, values);
    }
    if (result == GSF_OK) result = gsf_nn_save_tensors(&t->ctx, t->o.out, n.tensors, n.count);
    gsf_free(&t->ctx, n.tensors);
    gsf_free(&t->ctx, n.memory);
    return result;
}

static void add_loss(gsf__mini_loss* sum, const gsf__mini_loss* loss, double share) {
    sum->relative += share * loss->relative;
    sum->square += share * loss->square;
    sum->before += share * loss->before;
    sum->likelihood += share * loss->likelihood;
    sum->fault += share * loss->fault;
}

// The gradients of a batch, in t->params; loss: of the rank's part of it.
static gsf_result train_batch(training* t, gsf__mini_loss* loss, double* total) {
    gsf_result result = GSF_OK;
    memset(loss, 0, sizeof *loss);
    t->batch.step = t->params.step;
    for (int g = 0; g < t->sum.own && result == GSF_OK; g++) {
        gsf__mini_loss part;
        const size_t each = (size_t)(t->o.batch / t->o.groups);
        t->batch.first = (size_t)(t->ranks.rank * t->sum.own + g) * each;
        t->ctx.parallel.for_fn(t->ctx.parallel.user, each, make_sample, &t->batch);
        result = gsf__mini_forward(&t->run, t->inputs);
        if (result == GSF_OK) result = gsf__mini_measure_loss(&t->run, t->truth, &part);
        if (result == GSF_OK) result = gsf__mini_backward(&t->run, &t->params);
        if (result != GSF_OK) break;
        add_loss(loss, &part, 1.0 / t->sum.own);
        training_add_group(&t->sum, g, part.total, t->params.grad);
    }
    if (result == GSF_OK) *total = training_add_ranks(&t->sum, t->params.grad) / t->o.groups;
    return result;
}

static gsf_result train(training* t) {
    gsf__nn_adam_desc adam;
    gsf__mini_loss sum;
    int counted = 0;
    memset(&adam, 0, sizeof adam);
    memset(&sum, 0, sizeof sum);
    adam.lr = t->o.rate;
    adam.beta2 = 0.99;
    adam.weight_decay = 1e-4;
    adam.max_norm = 1.0;
    adam.warmup = t->o.steps < 200 ? t->o.steps / 2 : 100;
    adam.steps = t->o.steps;
    adam.batches = t->o.groups;
    gsf_result result = GSF_OK;
    while (t->params.step < t->o.steps && result == GSF_OK) {
        const double step = (double)t->params.step;
        gsf__mini_loss loss;
        double norm, total;
        result = train_batch(t, &loss, &total);
        adam.average = step / (step + 30.0) < 0.998 ? step / (step + 30.0) : 0.998; // short memory at first
        if (result == GSF_OK) result = gsf__nn_step_adam(&t->ctx, &t->params, &adam, &norm);
        if (result == GSF_OK) result = training_keep_loss(&t->ctx, &t->log, total);
        if (result != GSF_OK || t->ranks.rank != 0) continue;
        add_loss(&sum, &loss, 1.0);
        counted++;
        if (t->params.step % 100 == 0 || t->params.step == t->o.steps) {
            fprintf(stderr, "step %lld of %d, %.1f CPU minutes: relative error %.3f, %.2f -> %.2f dB, likelihood %.3f, %.3f\n",
                    (long long)t->params.step, t->o.steps, training_cpu_minutes(), sum.relative / counted,
                    decibels(sum.before / counted), decibels(sum.square / counted), sum.likelihood / counted,
                    sum.fault / counted);
            memset(&sum, 0, sizeof sum);
            counted = 0;
        }
        if (t->params.step % t->o.save_every == 0 || t->params.step == t->o.steps) {
            result = save_state(t);
            if (result == GSF_OK) result = save_network(t);
        }
    }
    return result;
}

// ---- measuring -------------------------------------------------------------------

typedef struct figures { double before, after; } figures; // decibels

typedef struct checking {
    gsf__mini_run run;
    mini_sample sample; // a whole frame
    int64_t width, height;
} checking;

// Mean squared errors of a frame before and after.
static gsf_result measure_frame(checking* c, figures* squares) {
    const mini_sample s = c->sample;
    const gsf__mini_input input = {c->width, c->height, DATA_REFERENCES, s.frame, s.shown};
    const gsf_result result = gsf__mini_forward(&c->run, &input);
    *squares = (figures){0.0, 0.0};
    for (int64_t y = 0; y < c->height && result == GSF_OK; y++)
        for (int64_t x = 0; x < 3 * c->width; x++) {
            const double truth = (double)s.truth[y * 3 * c->width + x];
            const double a = (double)s.frame[(y * c->width + x / 3) * GSF__MINI_FRAME + x % 3] - truth;
            const double b = (double)gsf__mini_clamp(c->run.out[y * 3 * c->run.width + x], 0.0f, 1.0f) - truth;
            squares->before += a * a / (double)(3 * c->width * c->height);
            squares->after += b * b / (double)(3 * c->width * c->height);
        }
    return result;
}

static void add_frame(figures* sum, figures squares, double part) {
    sum->before += part * decibels(squares.before);
    sum->after += part * decibels(squares.after);
}

// PSNR of whole frames before and after, mean over the frames of a scene; `good`: of the same frames with so small a part of
// their faults that they are at GOOD_DECIBELS, which should stay as they are.
enum { GOOD_DECIBELS = 40 };
static gsf_result check_scene(training* t, const gsf__mini* net, const gsf_nn_tensor* frames, figures* all, figures* good) {
    const int64_t height = frames->shape[1], width = frames->shape[2], pixels = height * width;
    const size_t planes = GSF__MINI_FRAME + DATA_REFERENCES * GSF__MINI_REFERENCE;
    const double share = 1.0 / (double)frames->shape[0];
    float* memory = (float*)gsf_alloc(&t->ctx, (size_t)pixels, (planes + 3) * sizeof(float));
    const byte_values values = list_values();
    checking c;
    memset(&c, 0, sizeof c);
    gsf_result result = gsf__mini_begin(&t->ctx, net, 1, DATA_REFERENCES, width, height, 0, &c.run);
    if (!memory) result = GSF_ERROR_OUT_OF_MEMORY;
    c.sample = (mini_sample){memory, memory + pixels * GSF__MINI_FRAME, memory + pixels * (int64_t)planes};
    c.width = width;
    c.height = height;
    *all = *good = (figures){0.0, 0.0};
    for (int64_t f = 0; f < frames->shape[0] && result == GSF_OK; f++) {
        const uint8_t* from = (const uint8_t*)frames->data + f * pixels * DATA_PIXEL;
        figures squares;
        for (int64_t i = 0; i < pixels; i++) read_pixel(&values, from + i * DATA_PIXEL, c.sample, i, pixels);
        result = measure_frame(&c, &squares);
        add_frame(all, squares, share);
        const float part = (float)fmin(1.0, sqrt(pow(10.0, -0.1 * GOOD_DECIBELS) / fmax(squares.before, 1e-10)));
        for (int64_t i = 0; i < pixels; i++) better_pixel(part, part, c.sample, i, pixels);
        if (result == GSF_OK) result = measure_frame(&c, &squares);
        add_frame(good, squares, share);
    }
    gsf__mini_end(&c.run);
    gsf_free(&t->ctx, memory);
    return result;
}

static gsf_result check(training* t) {
    gsf__mini net;
    figures sum = {0.0, 0.0}, good_sum = {0.0, 0.0};
    const double share = 1.0 / (double)t->check_count;
    if (!t->check_count || t->ranks.rank != 0) return GSF_OK;
    gsf_result result = gsf__mini_open(&t->ctx, t->o.out, NULL, 0, &net);
    for (size_t i = 0; i < t->check_count && result == GSF_OK; i++) {
        figures all, good;
        result = check_scene(t, &net, t->scenes[t->scene_count + i], &all, &good);
        if (result != GSF_OK) break;
        printf("scene %llu: %.2f -> %.2f dB; nearly right: %.2f -> %.2f dB\n", (unsigned long long)seed_at(&t->o.check, i),
               all.before, all.after, good.before, good.after);
        sum.before += share * all.before, sum.after += share * all.after;
        good_sum.before += share * good.before, good_sum.after += share * good.after;
    }
    if (result == GSF_OK) {
        printf("mean: %.2f -> %.2f dB (%+.2f)\n", sum.before, sum.after, sum.after - sum.before);
        printf("nearly right: %.2f -> %.2f dB\n", good_sum.before, good_sum.after);
    }
    gsf__mini_close(&t->ctx, &net);
    return result;
}

// ---- command line ----------------------------------------------------------------

static int usage(FILE* to) {
    fprintf(to, "usage: train_mini OUT.safetensors --data DIR [--scenes 1001-1060] [--check 1061-1064]\n"
                "       [--steps 14000 | --quick] [--resume] [--batch 8] [--crop 96] [--rate 0.001] [--seed 1] [--save-every 500] [--init FILE]\n"
                "       [--threads N] [--make-only] [--pixels 216] [--fit 599] [--own FILE] [--groups 1]\n"
                "       [--better 0] [--int8]\n"
                "Makes training data for the restorer mini from seeds, and trains it.\n");
    return to == stdout ? 0 : 2;
}

static int parse_seeds(const char* text, seeds* out) { // "A-B,C,D-E" or "0" for none
    memset(out, 0, sizeof *out);
    if (strcmp(text, "0") == 0) return 1;
    for (;;) {
        char* end;
        const uint64_t first = strtoull(text, &end, 10), last = *end == '-' ? strtoull(end + 1, &end, 10) : first;
        if (end == text || !first || last < first || last >= 1000000000 || last - first >= 10000 || out->ranges == SEED_RANGES)
            return 0;
        out->first[out->ranges] = first;
        out->last[out->ranges++] = last;
        if (!*end) return 1;
        if (*end != ',') return 0;
        text = end + 1;
    }
}

static int parse_options(int argc, char** argv, options* o) {
    for (int i = 1; i < argc; i++) {
        const char* name = argv[i];
        if (strcmp(name, "--quick") == 0) o->steps = 4000;
        else if (strcmp(name, "--resume") == 0) o->resume = 1;
        else if (strcmp(name, "--make-only") == 0) o->make_only = 1;
        else if (strcmp(name, "--int8") == 0) o->int8 = 1;
        else if (name[0] != '-') {
            if (o->out) return 0;
            o->out = name;
        } else {
            if (++i == argc) return 0;
            const char* value = argv[i];
            char* end = NULL;
            const double x = strtod(value, &end);
            const int number = end != value && !*end && x >= 0.0 && x < 1e9;
            if (strcmp(name, "--data") == 0) o->data = value;
            else if (strcmp(name, "--init") == 0) o->init = value;
            else if (strcmp(name, "--own") == 0) o->own = value;
            else if (strcmp(name, "--scenes") == 0) { if (!parse_seeds(value, &o->scenes)) return 0; }
            else if (strcmp(name, "--check") == 0) { if (!parse_seeds(value, &o->check)) return 0; }
            else if (!number) return 0;
            else if (strcmp(name, "--steps") == 0) o->steps = (int)x;
            else if (strcmp(name, "--batch") == 0) o->batch = (int)x;
            else if (strcmp(name, "--crop") == 0) o->crop = (int)x;
            else if (strcmp(name, "--rate") == 0) o->rate = x;
            else if (strcmp(name, "--better") == 0) o->better = x;
            else if (strcmp(name, "--seed") == 0) o->seed = (uint64_t)x;
            else if (strcmp(name, "--save-every") == 0) o->save_every = (int)x;
            else if (strcmp(name, "--threads") == 0) o->threads = (int)x;
            else if (strcmp(name, "--pixels") == 0) o->pixels = (int)x;
            else if (strcmp(name, "--fit") == 0) o->fit = (int)x;
            else if (strcmp(name, "--groups") == 0) o->groups = (int)x;
            else return 0;
        }
    }
    return o->out && o->data && seed_count(&o->scenes) && o->steps > 0 && o->batch > 0 && o->batch <= 64 && o->save_every > 0 &&
           o->better <= 1.0 && training_is_power(o->groups) && o->batch % o->groups == 0 &&
           o->crop >= 16 && o->crop % GSF__MINI_MULTIPLE == 0 && o->fit >= 3 && o->pixels >= 24 && o->pixels <= 4096 &&
           2 * o->pixels / 3 >= o->crop;
}

int main(int argc, char** argv) {
    static training t;
    t.o = (options){.scenes = {1, {1001}, {1060}}, .check = {1, {1061}, {1064}}, .steps = 14000, .batch = 8, .crop = 96,
                    .save_every = 500, .pixels = 216, .fit = 599, .groups = 1, .seed = 1, .rate = 1e-3};
    if (argc == 2 && strcmp(argv[1], "--help") == 0) return usage(stdout);
    if (!parse_options(argc, argv, &t.o)) return usage(stderr);
    t.ctx.threads = t.o.threads;
    gsf_result result = gsf_init_context(&t.ctx);
    t.ranks = training_begin(&t.ctx, &argc, &argv);
    if (result == GSF_OK && t.ranks.rank == 0) result = open_data(&t); // it makes what is missing
    if (result == GSF_OK) training_wait(t.ranks);
    if (result == GSF_OK && t.ranks.rank != 0) result = open_data(&t);
    if (result == GSF_OK && !t.o.make_only) {
        result = open_network(&t);
        if (result == GSF_OK) result = make_batches(&t);
        if (result == GSF_OK) result = train(&t);
        if (result == GSF_OK) result = check(&t);
    }
    if (result != GSF_OK) fprintf(stderr, "train_mini: %s\n", t.ctx.error);
    gsf_destroy_restorer(&t.ctx, &t.own);
    training_end_sum(&t.ctx, &t.sum);
    gsf_free(&t.ctx, t.log.losses);
    gsf__mini_end(&t.run);
    gsf__nn_destroy_params(&t.ctx, &t.params);
    gsf__mini_close(&t.ctx, &t.net);
    for (size_t i = 0; t.files && i < t.scene_count + t.check_count; i++) gsf_nn_destroy_weights(&t.ctx, t.files + i);
    gsf_free(&t.ctx, t.files);
    gsf_free(&t.ctx, (void*)t.scenes);
    gsf_free(&t.ctx, t.planes);
    gsf_free(&t.ctx, t.truth);
    gsf_free(&t.ctx, t.inputs);
    gsf_free(&t.ctx, t.batch.samples);
    return training_end(t.ranks, result == GSF_OK ? 0 : 1);
}
