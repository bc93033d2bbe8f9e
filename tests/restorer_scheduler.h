// The noise schedule and DDIM against those of diffusers: time steps exact, the float64 table within 1e-12, the float32
// table within 1e-6, trajectories within 4e-6 relative to magnitude (the reference's own float32 runs differ from
// float64 by up to 1.2e-6), noise and velocity within float32 rounding plus the difference of the two tables.
#ifndef RESTORER_SCHEDULER_H
#define RESTORER_SCHEDULER_H

static double scheduler_worst(const float* a, const test_tensor* b, size_t first, size_t count) {
    double worst = 0.0;
    for (size_t i = 0; i < count; i++) {
        const double e = fabs(a[i] - b->v[first + i]) / fmax(1.0, fabs(b->v[first + i]));
        if (!(e <= worst)) worst = e;
    }
    return worst;
}

static void scheduler_check_trajectory(gsf_context* ctx, const test_tensors* file, int steps, const char* family,
                                       const gsf_nn_schedule* schedule) {
    static const char* const parts[] = {"x_f64", "x", "x0"}; // float64, float32, and the predictions
    char name[80];
    snprintf(name, sizeof name, "traj%d.x_init", steps);
    test_tensor start = test_get_tensor(file, name);
    snprintf(name, sizeof name, "traj%d.model_output", steps);
    test_tensor v = test_get_tensor(file, name);
    float *x = test_tensor_floats(&start), *outputs = test_tensor_floats(&v);
    float* x0 = (float*)malloc(start.count * sizeof(float));
    test_tensor expected[3];
    for (int k = 0; k < 3; k++) {
        snprintf(name, sizeof name, "traj%d.%s.%s", steps, family, parts[k]);
        expected[k] = test_get_tensor(file, name);
    }
    gsf_nn_sampler_desc desc;
    gsf_nn_sampler sampler;
    memset(&desc, 0, sizeof desc);
    desc.steps = steps;
    desc.value_count = start.count;
    if (CHECK_OK(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &sampler))) {
        CHECK(sampler.count == steps && v.count == (size_t)steps * start.count);
        for (int i = 0; i < sampler.count; i++) {
            const size_t at = (size_t)i * start.count;
            CHECK_OK(ctx, gsf_nn_step_sampler(ctx, &sampler, outputs + at, x, x0));
            for (int k = 0; k < 3; k++)
                CHECK_NEAR(scheduler_worst(k == 2 ? x0 : x, &expected[k], at, start.count), 0.0, 4e-6);
        }
        CHECK_RESULT(ctx, gsf_nn_step_sampler(ctx, &sampler, outputs, x, NULL), GSF_ERROR_INVALID_ARGUMENT);
        gsf_nn_destroy_sampler(ctx, &sampler);
    }
    for (int k = 0; k < 3; k++) test_free_tensor(&expected[k]);
    test_free_tensor(&start);
    test_free_tensor(&v);
    free(x);
    free(outputs);
    free(x0);
}

static void scheduler_check_table(const test_tensors* file, const char* name, const gsf_nn_schedule* schedule,
                                  double tolerance) {
    test_tensor t = test_get_tensor(file, name);
    if (CHECK(t.count == (size_t)schedule->desc.train_steps))
        test_compare(name, schedule->alpha_bar, t.v, t.count, tolerance);
    test_free_tensor(&t);
}

// Recomputes the formula in long double: within one float32 ulp.
static void scheduler_check_exact(const gsf_nn_schedule* schedule) {
    const gsf_nn_schedule_desc* d = &schedule->desc;
    const int n = d->train_steps;
    if (d->linear_betas || d->no_zero_snr || d->snr_shift_scale != 1.0) return;
    long double* root = (long double*)malloc((size_t)n * sizeof *root);
    long double product = 1.0L;
    for (int i = 0; i < n; i++) {
        const long double a = sqrtl(d->beta_start), b = sqrtl(d->beta_end), beta = a + (b - a) * i / (n - 1);
        product *= 1.0L - beta * beta;
        root[i] = sqrtl(product);
    }
    int bad = 0;
    for (int i = 0; i < n; i++) {
        const long double r = (root[i] - root[n - 1]) * root[0] / (root[0] - root[n - 1]);
        const float exact = (float)(r * r);
        bad += fabs((double)((float)schedule->alpha_bar[i] - exact)) > (double)(nextafterf(exact, INFINITY) - exact);
    }
    CHECK(bad == 0);
    free(root);
}

typedef struct scheduler_roots { double a, s; } scheduler_roots; // of abar and of 1 - abar

static scheduler_roots scheduler_roots_of(double alpha_bar) {
    const scheduler_roots r = {sqrt(alpha_bar), sqrt(1.0 - alpha_bar)};
    return r;
}

// Our a x + s y (or minus s y) against theirs. The rounding error scales with the two products, which may cancel in the
// sum: float32 takes up to six roundings of 6e-8 each, including those of a and s. Beyond that, only the difference
// between our roots and theirs is allowed.
static void scheduler_check_mix(float actual, double expected, const scheduler_roots* ours,
                                const scheduler_roots* theirs, double x, double y) {
    const double size = ours->a * fabs(x) + ours->s * fabs(y);
    const double explained = fabs(ours->a - theirs->a) * fabs(x) + fabs(ours->s - theirs->s) * fabs(y);
    CHECK_NEAR(actual, expected, 4e-7 * size + explained);
}

static void scheduler_check_noise(gsf_context* ctx, const test_tensors* file, const gsf_nn_schedule* schedule) {
    test_tensor x0 = test_get_tensor(file, "noise.x0"), eps = test_get_tensor(file, "noise.eps");
    test_tensor t = test_get_tensor(file, "noise.t"), noisy = test_get_tensor(file, "noise.ddim.add_noise");
    test_tensor velocity = test_get_tensor(file, "noise.ddim.velocity");
    test_tensor table = test_get_tensor(file, "ddim.alphas_cumprod");
    float *x = test_tensor_floats(&x0), *e = test_tensor_floats(&eps);
    const size_t row = x0.count / t.count;
    float *out = (float*)malloc(3 * row * sizeof(float)), *v = out + row, *back = v + row;
    for (size_t i = 0; i < t.count; i++) {
        const int32_t time = (int32_t)t.v[i];
        const scheduler_roots ours = scheduler_roots_of(schedule->alpha_bar[time]);
        const scheduler_roots theirs = scheduler_roots_of(table.v[time]);
        gsf__nn_add_noise(ctx, schedule, time, x + i * row, e + i * row, row, out);
        gsf__nn_make_velocity(ctx, schedule, time, x + i * row, e + i * row, row, v);
        gsf__nn_predict_x0(ctx, schedule, time, out, v, row, back);
        for (size_t k = 0, at = i * row; k < row; k++, at++) {
            scheduler_check_mix(out[k], noisy.v[at], &ours, &theirs, x0.v[at], eps.v[at]);
            scheduler_check_mix(v[k], velocity.v[at], &ours, &theirs, eps.v[at], x0.v[at]);
            CHECK_NEAR(back[k], x0.v[at], 4e-7 * fmax(1.0, fabs(x0.v[at]))); // does not depend on their table
        }
    }
    free(out);
    free(x);
    free(e);
    test_free_tensor(&x0);
    test_free_tensor(&eps);
    test_free_tensor(&t);
    test_free_tensor(&noisy);
    test_free_tensor(&velocity);
    test_free_tensor(&table);
}

static void check_scheduler(void) {
    gsf_context ctx;
    gsf_nn_schedule schedule, shifted;
    gsf_nn_weights names;
    test_context_init(&ctx);
    const char* config = test_golden("restorer/model/scheduler/scheduler_config.json");
    const char* path = test_golden("restorer/scheduler/scheduler.safetensors");
    CHECK_OK(&ctx, gsf_nn_load_schedule(&ctx, config, &schedule));
    gsf_nn_schedule_desc desc = schedule.desc;
    desc.snr_shift_scale = 3.0;
    CHECK_OK(&ctx, gsf_nn_make_schedule(&ctx, &desc, &shifted));
    if (!schedule.alpha_bar || !shifted.alpha_bar) return;
    test_tensors file = test_open_tensors(path);
    scheduler_check_table(&file, "ddim.alphas_cumprod", &schedule, 1e-6);
    scheduler_check_table(&file, "cogx_ddim.alphas_cumprod", &schedule, 1e-12);
    scheduler_check_table(&file, "cogx_ddim_shift3.alphas_cumprod", &shifted, 1e-12);
    scheduler_check_exact(&schedule);
    scheduler_check_noise(&ctx, &file, &schedule);
    int lists = 0, trajectories = 0;
    CHECK_OK(&ctx, gsf_nn_load_weights(&ctx, path, NULL, &names));
    for (size_t i = 0; i < names.tensor_count; i++) {
        const char* name = names.tensors[i].name;
        int steps, end = 0;
        if (sscanf(name, "timesteps%d%n", &steps, &end) == 1 && name[end] == 0) {
            test_tensor t = test_get_tensor(&file, name);
            int32_t* times = (int32_t*)malloc((size_t)steps * sizeof *times), count;
            if (CHECK_OK(&ctx, gsf__nn_make_timesteps(&ctx, &schedule, steps, 1.0, times, &count)) &&
                CHECK((size_t)count == t.count))
                for (size_t k = 0; k < t.count; k++) CHECK((double)times[k] == t.v[k]);
            free(times);
            test_free_tensor(&t);
            lists++;
        }
        end = 0;
        if (sscanf(name, "traj%d.x_init%n", &steps, &end) == 1 && end > 0) {
            scheduler_check_trajectory(&ctx, &file, steps, "ddim", &schedule);
            scheduler_check_trajectory(&ctx, &file, steps, "cogx_ddim", &schedule);
            trajectories++;
        }
    }
    CHECK(lists > 0 && trajectories > 0);
    gsf_nn_destroy_weights(&ctx, &names);
    test_close_tensors(&file);
    gsf_nn_destroy_schedule(&ctx, &schedule);
    gsf_nn_destroy_schedule(&ctx, &shifted);
}

#endif
