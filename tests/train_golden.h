// train_golden.h - loss, Adam, learning rates and densification against golden data of Inria's Python code.
// Needs GSFIXER_IMPLEMENTATION (it calls internals); a part of golden_splat.c.
#ifndef TRAIN_GOLDEN_H
#define TRAIN_GOLDEN_H

#include "splat_golden.h"

// ---- loss ----------------------------------------------------------------------

// Planar (3,H,W) tensor as packed floats.
static inline float* train_golden_pixels(const test_tensor* t, double scale) {
    double* wide = splat_golden_interleave(t);
    float* out = (float*)malloc((t->count + 1) * sizeof(float));
    for (size_t i = 0; i < t->count; i++) out[i] = (float)(wide[i] * scale);
    free(wide);
    return out;
}

static inline void train_golden_loss(gsf_context* ctx) {
    gsf__loss_scratch scratch;
    memset(&scratch, 0, sizeof scratch);
    const test_names scenes = splat_golden_scenes();
    for (size_t s = 0; s < scenes.count; s++) {
        char label[160];
        snprintf(label, sizeof label, "splat/scenes/%s.safetensors", scenes.name[s]);
        test_tensors file = test_open_tensors(test_golden(label));
        test_tensor image = test_get_tensor(&file, "out.image"), photo = test_get_tensor(&file, "in.target");
        test_tensor loss = test_get_tensor(&file, "loss"), gradient = test_get_tensor(&file, "grad.dL_dimage");
        float *render = train_golden_pixels(&image, 1.0), *pixels = train_golden_pixels(&photo, 1.0);
        double* expected = splat_golden_interleave(&gradient);
        float* d = (float*)malloc((image.count + 1) * sizeof(float));
        gsf__target target;
        memset(&target, 0, sizeof target);
        target.width = (int32_t)image.dim[2];
        target.height = (int32_t)image.dim[1];
        target.f32 = pixels;
        gsf__loss_value value;
        CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, 0.2f, 1.0f, d, &value));
        CHECK_NEAR(value.total, loss.v[0], 3e-7);
        CHECK_NEAR(value.l1, loss.v[1], 3e-7);
        CHECK_NEAR(value.ssim, loss.v[2], 3e-7);
        snprintf(label, sizeof label, "%s dL/dimage (%s)", scenes.name[s], gsf_describe_cpu_level(ctx->cpu_level));
        test_compare_floats(label, d, expected, image.count, 1e-5 * test_max_abs(expected, image.count));
        free(render); free(pixels); free(expected); free(d);
        test_free_tensor(&image); test_free_tensor(&photo); test_free_tensor(&loss); test_free_tensor(&gradient);
        test_close_tensors(&file);
    }
    gsf__loss_destroy_scratch(ctx, &scratch);
}

static inline void train_golden_ssim_gradient(gsf_context* ctx) {
    static const char suffix[] = ".grad_ssim_wrt_a";
    gsf__loss_scratch scratch;
    memset(&scratch, 0, sizeof scratch);
    test_tensors file = test_open_tensors(test_golden("metrics/pairs.safetensors"));
    uint64_t header;
    memcpy(&header, file.data, 8);
    gsf_json json;
    CHECK_OK(ctx, gsf_parse_json(ctx, file.path, file.data + 8, (size_t)header, &json));
    size_t pairs = 0;
    for (uint32_t entry = json.values[0].child; entry; entry = json.values[entry].next) {
        const size_t length = strlen(json.values[entry].key);
        if (length < sizeof suffix || strcmp(json.values[entry].key + length - (sizeof suffix - 1), suffix) != 0) continue;
        pairs++;
        char pair[96], label[160];
        snprintf(pair, sizeof pair, "%.*s", (int)(length - (sizeof suffix - 1)), json.values[entry].key);
        snprintf(label, sizeof label, "%s.a", pair);
        test_tensor a = test_get_tensor(&file, label);
        snprintf(label, sizeof label, "%s.b", pair);
        test_tensor b = test_get_tensor(&file, label);
        snprintf(label, sizeof label, "%s%s", pair, suffix);
        test_tensor gradient = test_get_tensor(&file, label);
        float *render = train_golden_pixels(&a, 1.0 / 255.0), *d = (float*)malloc((a.count + 1) * sizeof(float));
        double *expected = splat_golden_interleave(&gradient), *photo = splat_golden_interleave(&b);
        uint8_t* u8 = (uint8_t*)malloc(a.count + 1);
        for (size_t i = 0; i < b.count; i++) u8[i] = (uint8_t)photo[i];
        for (size_t i = 0; i < a.count; i++) expected[i] = -expected[i]; // the loss has 1 - SSIM
        gsf__target target;
        memset(&target, 0, sizeof target);
        target.width = (int32_t)a.dim[2];
        target.height = (int32_t)a.dim[1];
        target.u8 = u8;
        gsf__loss_value value;
        CHECK_OK(ctx, gsf__loss(ctx, &scratch, &target, render, 1.0f, 1.0f, d, &value));
        test_compare_floats(label, d, expected, a.count, 1e-4 * test_max_abs(expected, a.count)); // flat parts: s ~ C2
        free(render); free(d); free(expected); free(photo); free(u8);
        test_free_tensor(&a); test_free_tensor(&b); test_free_tensor(&gradient);
    }
    CHECK(pairs > 0);
    gsf_destroy_json(ctx, &json);
    test_close_tensors(&file);
    gsf__loss_destroy_scratch(ctx, &scratch);
}

// ---- the model's tensors by their golden names --------------------------------------

typedef struct train_golden_tensor { const char* name; int group; size_t begin, end; } train_golden_tensor;
static const train_golden_tensor train_golden_tensors[] = { // order of the columns of `lr`; floats of a row
    {"xyz", GSF__MEANS, 0, 3},   {"f_dc", GSF__SH, 0, 3},      {"f_rest", GSF__SH, 3, 48},
    {"opacity", GSF__OPACITY, 0, 1}, {"scaling", GSF__SCALES, 0, 3}, {"rotation", GSF__QUATS, 0, 4}};

typedef enum train_golden_part { TRAIN_VALUE, TRAIN_M, TRAIN_V, TRAIN_GRAD } train_golden_part;

static inline float* train_golden_part_of(gsf__model* model, int group, train_golden_part part) {
    gsf__group* g = &model->groups[group];
    return part == TRAIN_VALUE ? g->value : part == TRAIN_M ? g->m : part == TRAIN_V ? g->v : g->grad;
}

static inline void train_golden_fill(const test_tensors* file, const char* prefix, train_golden_part part,
                                     gsf__model* model) {
    for (size_t t = 0; t < sizeof train_golden_tensors / sizeof *train_golden_tensors; t++) {
        const train_golden_tensor* e = &train_golden_tensors[t];
        char name[96];
        snprintf(name, sizeof name, "%s.%s", prefix, e->name);
        test_tensor from = test_get_tensor(file, name);
        const size_t width = model->groups[e->group].width;
        const size_t used = e->end < width ? e->end - e->begin : width - e->begin;
        CHECK(from.count == model->count * used);
        for (size_t i = 0; i < model->count; i++)
            for (size_t k = 0; k < used; k++)
                train_golden_part_of(model, e->group, part)[i * width + e->begin + k] = (float)from.v[i * used + k];
        test_free_tensor(&from);
    }
}

// The tolerance is relative for values above 1, else absolute.
static inline void train_golden_check(const test_tensors* file, const char* prefix, train_golden_part part,
                                      gsf__model* model, double tolerance) {
    for (size_t t = 0; t < sizeof train_golden_tensors / sizeof *train_golden_tensors; t++) {
        const train_golden_tensor* e = &train_golden_tensors[t];
        char name[96];
        snprintf(name, sizeof name, "%s.%s", prefix, e->name);
        test_tensor expected = test_get_tensor(file, name);
        const size_t width = model->groups[e->group].width;
        const size_t used = e->end < width ? e->end - e->begin : width - e->begin;
        if (!CHECK(expected.count == model->count * used)) continue;
        size_t wrong = 0;
        double worst = 0.0;
        for (size_t i = 0; i < model->count; i++)
            for (size_t k = 0; k < used; k++) {
                const double want = expected.v[i * used + k];
                const double got = (double)train_golden_part_of(model, e->group, part)[i * width + e->begin + k];
                const double error = fabs(got - want) / (fabs(want) > 1.0 ? fabs(want) : 1.0);
                wrong += !(error <= tolerance);
                if (!(error <= worst)) worst = error;
            }
        if (!CHECK(wrong == 0)) fprintf(stderr, "%s: %zu values differ, worst %.3g\n", name, wrong, worst);
        test_free_tensor(&expected);
    }
}

static inline gsf__model train_golden_model(gsf_context* ctx, const test_tensors* file) {
    gsf__model model;
    memset(&model, 0, sizeof model);
    test_tensor xyz = test_get_tensor(file, "before.xyz"), rest = test_get_tensor(file, "before.f_rest");
    while ((size_t)gsf_splat_count_sh(model.sh_degree) < rest.dim[1] + 1) model.sh_degree++;
    if (!CHECK_OK(ctx, gsf__model_reserve(ctx, &model, xyz.dim[0]))) exit(2);
    model.count = xyz.dim[0];
    train_golden_fill(file, "before", TRAIN_VALUE, &model);
    test_free_tensor(&xyz);
    test_free_tensor(&rest);
    return model;
}

// ---- Adam ----------------------------------------------------------------------

// Do the parameters after the steps differ from those before? In the committed files they do not, except for rounding to
// float32 (their moments are correct), so they cannot be used to check a step.
static inline int train_golden_moved(const test_tensors* file, const char* prefix) {
    double largest = 0.0;
    for (size_t t = 0; t < sizeof train_golden_tensors / sizeof *train_golden_tensors; t++) {
        char name[96];
        snprintf(name, sizeof name, "before.%s", train_golden_tensors[t].name);
        test_tensor before = test_get_tensor(file, name);
        snprintf(name, sizeof name, "%s.%s", prefix, train_golden_tensors[t].name);
        test_tensor after = test_get_tensor(file, name);
        for (size_t i = 0; i < before.count && i < after.count; i++) {
            const double moved = fabs(after.v[i] - before.v[i]);
            if (moved > largest) largest = moved;
        }
        test_free_tensor(&before);
        test_free_tensor(&after);
    }
    return largest > 1e-5;
}

// torch.optim.Adam in double precision, with the file's gradients and rates. Its moments are compared with the file's,
// its parameters with the file's if these moved, and `model` (which took the same steps) with both. Row 2 has gradients
// of 1e-13.
static inline void train_golden_adam_reference(const test_tensors* file, const test_tensor* lr, gsf__model* model) {
    const int moved = train_golden_moved(file, "after5.f64");
    for (size_t t = 0; t < sizeof train_golden_tensors / sizeof *train_golden_tensors; t++) {
        const train_golden_tensor* e = &train_golden_tensors[t];
        char name[96];
        snprintf(name, sizeof name, "before.%s", e->name);
        test_tensor value = test_get_tensor(file, name);
        double *m = (double*)calloc(value.count + 1, sizeof(double)),
               *v = (double*)calloc(value.count + 1, sizeof(double));
        for (int step = 1; step <= 5; step++) {
            snprintf(name, sizeof name, "grad%d.%s", step, e->name);
            test_tensor grad = test_get_tensor(file, name);
            for (size_t i = 0; i < value.count; i++) {
                m[i] = 0.9 * m[i] + 0.1 * grad.v[i];
                v[i] = 0.999 * v[i] + 0.001 * grad.v[i] * grad.v[i];
                const double root = sqrt(v[i]) / sqrt(1.0 - pow(0.999, step)) + 1e-15;
                value.v[i] -= lr->v[6 * (step - 1) + (int)t] / (1.0 - pow(0.9, step)) * m[i] / root;
            }
            test_free_tensor(&grad);
        }
        snprintf(name, sizeof name, "exp_avg.f64.%s", e->name);
        test_tensor first = test_get_tensor(file, name);
        snprintf(name, sizeof name, "exp_avg_sq.f64.%s", e->name);
        test_tensor second = test_get_tensor(file, name);
        snprintf(name, sizeof name, "after5.f64.%s", e->name);
        test_tensor after = test_get_tensor(file, name);
        test_compare(first.name, m, first.v, value.count, 1e-12);
        test_compare(second.name, v, second.v, value.count, 1e-12);
        if (moved) test_compare(after.name, value.v, after.v, value.count, 1e-6); // the file's initial values are not rounded
        const size_t width = model->groups[e->group].width;
        const size_t used = e->end < width ? e->end - e->begin : width - e->begin;
        size_t wrong = 0;
        for (size_t i = 0; i < value.count; i++) {
            const size_t at = i / used * width + e->begin + i % used;
            const double got = (double)model->groups[e->group].value[at];
            wrong += !(fabs(got - value.v[i]) <= 1e-6 * (fabs(value.v[i]) > 1.0 ? fabs(value.v[i]) : 1.0));
            wrong += !(fabs((double)model->groups[e->group].m[at] - m[i]) <= 1e-6 * fabs(m[i]) + 1e-9);
            wrong += !(fabs((double)model->groups[e->group].v[at] - v[i]) <= 1e-6 * v[i]);
        }
        if (!CHECK(wrong == 0)) fprintf(stderr, "%s after five steps: %zu values differ\n", e->name, wrong);
        free(m); free(v);
        test_free_tensor(&value); test_free_tensor(&first); test_free_tensor(&second); test_free_tensor(&after);
    }
}

static inline void train_golden_adam(gsf_context* ctx, const char* name) {
    char path[160];
    snprintf(path, sizeof path, "splat/%s.safetensors", name);
    test_tensors file = test_open_tensors(test_golden(path));
    gsf__model model = train_golden_model(ctx, &file);
    test_tensor lr = test_get_tensor(&file, "lr");
    CHECK(lr.count == 30);
    for (int step = 0; step < 5; step++) {
        char prefix[16];
        snprintf(prefix, sizeof prefix, "grad%d", step + 1);
        train_golden_fill(&file, prefix, TRAIN_GRAD, &model);
        gsf__adam_rates rates;
        const double* row = lr.v + 6 * step;
        rates.means = row[0];
        rates.sh_dc = row[1];
        rates.sh_rest = row[2];
        rates.opacity = row[3];
        rates.scales = row[4];
        rates.quats = row[5];
        CHECK(gsf__adam_step(ctx, &model, &rates, step + 1, model.sh_degree + 1) == 0);
        size_t left = 0; // gradients are consumed
        for (int g = 0; g < GSF__GROUPS; g++)
            for (size_t i = 0; i < model.count * model.groups[g].width; i++) left += model.groups[g].grad[i] != 0.0f;
        CHECK(left == 0);
    }
    train_golden_adam_reference(&file, &lr, &model);
    gsf__model_destroy(ctx, &model);
    test_free_tensor(&lr);
    test_close_tensors(&file);
}

static inline double train_golden_number(const char* text, const char* key) { // "key=number" in metadata
    const char* at = text ? strstr(text, key) : NULL;
    return at ? strtod(at + strlen(key) + 1, NULL) : NAN;
}

static inline void train_golden_rates(void) {
    test_tensors file = test_open_tensors(test_golden("splat/lr_schedule.safetensors"));
    test_tensor steps = test_get_tensor(&file, "steps"), rates = test_get_tensor(&file, "position_lr");
    test_tensor delayed = test_get_tensor(&file, "delayed_lr");
    const double scale = strtod(test_metadata(&file, "spatial_lr_scale"), NULL);
    char text[512];
    snprintf(text, sizeof text, "%.511s", test_metadata(&file, "delayed"));
    for (size_t i = 0; i < steps.count; i++) {
        const int32_t step = (int32_t)steps.v[i];
        CHECK_NEAR(gsf__exponential_rate(step, 1.6e-4 * scale, 1.6e-6 * scale, 0, 0.01, 30000), rates.v[i],
                   1e-12 * rates.v[i]);
        CHECK_NEAR(gsf__exponential_rate(
                       step, train_golden_number(text, "lr_init"), train_golden_number(text, "lr_final"),
                       (int32_t)train_golden_number(text, "lr_delay_steps"), train_golden_number(text, "lr_delay_mult"),
                       (int32_t)train_golden_number(text, "max_steps")),
                   delayed.v[i], 1e-12 * fabs(delayed.v[i]));
    }
    test_free_tensor(&steps); test_free_tensor(&rates); test_free_tensor(&delayed);
    test_close_tensors(&file);
}

// ---- densification --------------------------------------------------------------

static inline double train_golden_setting(const test_tensors* file, const char* key) {
    const char* text = test_metadata(file, key);
    return text ? strtod(text, NULL) : NAN;
}

static inline void train_golden_check_indices(const test_tensors* file, const char* name, const gsf__model* model,
                                              gsf__densify_action action) {
    test_tensor expected = test_get_tensor(file, name);
    size_t found = 0, wrong = 0;
    for (size_t i = 0; i < model->count; i++)
        if (model->action[i] == (uint8_t)action) {
            wrong += found >= expected.count || expected.v[found] != (double)i;
            found++;
        }
    if (!CHECK(wrong == 0 && found == expected.count)) fprintf(stderr, "%s: %zu, %zu differ\n", name, found, wrong);
    test_free_tensor(&expected);
}

static inline void train_golden_densify(gsf_context* ctx, const char* name) {
    char path[160];
    snprintf(path, sizeof path, "splat/%s.safetensors", name);
    test_tensors file = test_open_tensors(test_golden(path));
    gsf__model model = train_golden_model(ctx, &file);
    const size_t before = model.count;
    train_golden_fill(&file, "before.exp_avg", TRAIN_M, &model);
    train_golden_fill(&file, "before.exp_avg_sq", TRAIN_V, &model);
    test_tensor sum = test_get_tensor(&file, "in.grad_accum"), denominator = test_get_tensor(&file, "in.denom");
    for (size_t i = 0; i < before; i++) {
        model.grad_sum[0][i] = (float)sum.v[i];
        model.visits[0][i] = (uint32_t)denominator.v[i];
        model.ids[i] = (uint32_t)(7 * i);
    }
    model.next_id = (uint32_t)(7 * before);
    test_tensor normals = test_get_tensor(&file, "rand.split_normals");
    float* given = test_tensor_floats(&normals);
    const double extent = train_golden_setting(&file, "extent");
    gsf__densify_rule rule;
    memset(&rule, 0, sizeof rule);
    rule.grad = (float)train_golden_setting(&file, "grad_threshold");
    rule.clone_scale = train_golden_setting(&file, "percent_dense") * extent;
    rule.prune_opacity = train_golden_setting(&file, "min_opacity");
    if (train_golden_setting(&file, "max_screen_size") > 0.0) rule.prune_scale = 0.1 * extent; // "None" parses as 0
    rule.max_splats = 1000000;
    rule.normals = given;
    size_t clones, splits;
    gsf__densify_select(&model, &rule, &clones, &splits);
    train_golden_check_indices(&file, "out.clone_idx", &model, GSF__CLONE);
    train_golden_check_indices(&file, "out.split_idx", &model, GSF__SPLIT);
    if (!CHECK(2 * splits == normals.dim[0])) exit(2);
    if (!CHECK_OK(ctx, gsf__model_reserve(ctx, &model, before + clones + 2 * splits))) exit(2);
    gsf__densify_apply(&model, &rule, clones, splits);
    train_golden_check(&file, "after", TRAIN_VALUE, &model, 1e-5);
    train_golden_check(&file, "after.exp_avg", TRAIN_M, &model, 0.0);
    train_golden_check(&file, "after.exp_avg_sq", TRAIN_V, &model, 0.0);
    size_t wrong = 0;
    for (size_t i = 0; i < model.count; i++) {
        wrong += model.visits[0][i] != 0 || model.grad_sum[0][i] != 0.0f || model.ids[i] >= model.next_id;
        for (size_t j = 0; j < i; j++) wrong += model.ids[i] == model.ids[j];
    }
    CHECK(wrong == 0);

    gsf__reset_opacity(&model, 0.01);
    test_tensor opacity = test_get_tensor(&file, "after_reset.opacity");
    test_tensor moment = test_get_tensor(&file, "after_reset.exp_avg.opacity");
    CHECK(opacity.count == model.count);
    test_compare_floats("after_reset.opacity", model.groups[GSF__OPACITY].value, opacity.v, model.count, 1e-5);
    test_compare_floats("after_reset.exp_avg.opacity", model.groups[GSF__OPACITY].m, moment.v, model.count, 0.0);
    size_t kept = 0; // nonzero second moments, which the file does not contain
    for (size_t i = 0; i < model.count; i++) kept += model.groups[GSF__OPACITY].v[i] != 0.0f;
    CHECK(kept == 0 && model.count > 0);
    gsf__model_destroy(ctx, &model);
    free(given);
    test_free_tensor(&sum); test_free_tensor(&denominator); test_free_tensor(&normals);
    test_free_tensor(&opacity); test_free_tensor(&moment);
    test_close_tensors(&file);
}

// Everything, with every instruction set of this machine.
static inline void train_golden_checks(void) {
    const test_names adam = test_list_golden("splat", "adam_", ".safetensors");
    const test_names densify = test_list_golden("splat", "densify_", ".safetensors");
    for (int level = GSF_CPU_SCALAR; level <= GSF_CPU_AMX; level++) {
        gsf_context ctx;
        memset(&ctx, 0, sizeof ctx);
        ctx.cpu_level = (gsf_cpu_level)level;
        if (!CHECK_OK(&ctx, gsf_init_context(&ctx))) return;
        train_golden_loss(&ctx);
        train_golden_ssim_gradient(&ctx);
        for (size_t k = 0; k < adam.count; k++) train_golden_adam(&ctx, adam.name[k]);
        for (size_t k = 0; k < densify.count; k++) train_golden_densify(&ctx, densify.name[k]);
    }
    train_golden_rates();
}

#endif
