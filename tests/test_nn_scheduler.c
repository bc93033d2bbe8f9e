// Noise schedule, time steps and solvers of gsfixer_nn.h: against a case with a closed-form solution and the multistep
// formulas written out; checkpoints, other orders of work, bad input. (The tables of diffusers: golden_restorer.)
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "test.h"
#include "test_hooks.h"

#define COUNT_OF(array) (sizeof(array) / sizeof((array)[0]))

// ---- Gaussian clean latents with mean MEAN and deviation s: the ideal model's prediction and the exact flow

#define MEAN 0.5

static double gaussian_x0(double bar, double s, double x) {
    return MEAN + sqrt(bar) * s * s / (bar * s * s + 1.0 - bar) * (x - sqrt(bar) * MEAN);
}

static double gaussian_v(double bar, double s, double x) { // also at bar = 0
    return (sqrt(bar) * x - gaussian_x0(bar, s, x)) / sqrt(1.0 - bar);
}

static double gaussian_flow(double bar, double s, double z) { return sqrt(bar) * MEAN + sqrt(bar * s * s + 1.0 - bar) * z; }

enum { VALUES = 4 };
static const double drawn[VALUES] = {-1.0, 0.3, 1.5, -2.2};

typedef struct flow_error { double at_199, at_end; } flow_error;

// Runs a solver on the Gaussian flow. Returns the largest error at time step 199, which all grids used here contain,
// and at the end, after the jump to abar = 1.
static flow_error run_flow(gsf_context* ctx, const gsf_nn_schedule* schedule, gsf_nn_solver solver, int steps,
                           double strength, double s) {
    flow_error error = {-1.0, -1.0};
    gsf_nn_sampler sampler;
    const gsf_nn_sampler_desc desc = {solver, steps, strength, VALUES};
    float x[VALUES], v[VALUES], x0[VALUES];
    if (!CHECK_OK(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &sampler))) return error;
    for (int i = 0; i < VALUES; i++)
        x[i] = (float)gaussian_flow(schedule->alpha_bar[sampler.timesteps[0]], s, drawn[i]);
    while (sampler.index < sampler.count) {
        const int32_t t = sampler.timesteps[sampler.index];
        const double bar = schedule->alpha_bar[t];
        for (int i = 0; i < VALUES; i++) {
            if (t == 199) error.at_199 = fmax(error.at_199, fabs((double)x[i] - gaussian_flow(bar, s, drawn[i])));
            v[i] = (float)gaussian_v(bar, s, (double)x[i]);
            x0[i] = (float)gaussian_x0(bar, s, (double)x[i]);
        }
        float predicted[VALUES];
        CHECK_OK(ctx, gsf_nn_step_sampler(ctx, &sampler, v, x, predicted));
        for (int i = 0; i < VALUES; i++) CHECK_NEAR(predicted[i], x0[i], 2e-6);
    }
    for (int i = 0; i < VALUES; i++)
        error.at_end = fmax(error.at_end, fabs((double)x[i] - gaussian_flow(schedule->final_alpha_bar, s, drawn[i])));
    gsf_nn_destroy_sampler(ctx, &sampler);
    return error;
}

static void test_schedule_order(gsf_context* ctx, const gsf_nn_schedule* schedule) {
    static const double low[] = {0.9, 1.8, 2.4}; // UniPC's corrector of order 2 makes it third order
    static const double high[] = {1.1, 2.2, 3.3};
    for (int solver = GSF_NN_SOLVER_DDIM; solver <= GSF_NN_SOLVER_UNIPC; solver++)
        for (int k = 0; k < 4; k++) {
            const double s = k & 1 ? 1.0 : 0.3, strength = k & 2 ? 0.6 : 1.0;
            const flow_error coarse = run_flow(ctx, schedule, (gsf_nn_solver)solver, 25, strength, s);
            const flow_error fine = run_flow(ctx, schedule, (gsf_nn_solver)solver, 100, strength, s);
            const double order = log2(coarse.at_199 / fine.at_199) / 2.0;
            CHECK(fine.at_199 > 0.0);
            CHECK(order > low[solver]);
            CHECK(order < high[solver]);
            CHECK(fine.at_end < coarse.at_end);
        }
    for (int k = 0; k < 2; k++) { // few steps, where the order matters most
        const double s = k ? 1.0 : 0.3;
        double error[3];
        for (int solver = 0; solver < 3; solver++)
            error[solver] = run_flow(ctx, schedule, (gsf_nn_solver)solver, 10, 1.0, s).at_199;
        CHECK(error[1] < 0.6 * error[0] && error[2] < 0.6 * error[1]);
    }
    for (int solver = 0; solver < 3; solver++) // the smallest numbers of steps
        for (int steps = 1; steps <= 3; steps++)
            CHECK(run_flow(ctx, schedule, (gsf_nn_solver)solver, steps, 1.0, 0.3).at_end < 1.0);
}

// ---- the formulas as in diffusers, in lambda; only where every lambda is finite

typedef struct lambda_point { double a, s, l; } lambda_point;

static lambda_point lambda_at(double bar) {
    const lambda_point p = {sqrt(bar), sqrt(1.0 - bar), 0.5 * log(bar / (1.0 - bar))};
    return p;
}

// multistep_dpm_solver_second_order_update (dpmsolver++, midpoint); p[0] is the point of x, p[1] the one before it
// (order 2).
static double plain_predictor(int order, lambda_point t, const lambda_point p[2], double x, const double m[2]) {
    const double h = t.l - p[0].l, r0 = order > 1 ? (p[0].l - p[1].l) / h : 1.0;
    const double d1 = order > 1 ? (m[0] - m[1]) / r0 : 0.0;
    return t.s / p[0].s * x - t.a * (exp(-h) - 1.0) * m[0] - 0.5 * t.a * (exp(-h) - 1.0) * d1;
}

// multistep_uni_c_bh_update (bh2): corrects x, from p[0] to t, with the model's output m_t at t.
static double plain_corrector(int order, lambda_point t, const lambda_point p[2], double x, const double m[2],
                              double m_t) {
    const double h = t.l - p[0].l, hh = -h, phi1 = expm1(hh), b_h = expm1(hh);
    double rho[2] = {0.0, 0.5}, d1 = 0.0, h_phi = phi1 / hh - 1.0;
    if (order > 1) {
        const double rk = (p[1].l - p[0].l) / h, b0 = h_phi / b_h, b1 = (h_phi / hh - 0.5) * 2.0 / b_h;
        rho[0] = (b1 - b0) / (rk - 1.0); // of rho0 + rho1 = b0, rk rho0 + rho1 = b1
        rho[1] = b0 - rho[0];
        d1 = (m[1] - m[0]) / rk;
    }
    return t.s / p[0].s * x - t.a * phi1 * m[0] - t.a * b_h * (rho[0] * d1 + rho[1] * (m_t - m[0]));
}

// A nonlinear model, so that every term contributes.
static double some_model(double bar, double x) { return 0.4 * sin(3.0 * x + bar) - 0.2 * x * sqrt(1.0 - bar); }

static void test_formulas(gsf_context* ctx) {
    gsf_nn_schedule_desc schedule_desc;
    gsf_nn_schedule schedule;
    memset(&schedule_desc, 0, sizeof schedule_desc);
    schedule_desc.no_zero_snr = 1;
    schedule_desc.no_alpha_one = 1; // so that the last lambda is finite, too
    CHECK_OK(ctx, gsf_nn_make_schedule(ctx, &schedule_desc, &schedule));
    for (int solver = GSF_NN_SOLVER_DPMPP_2M; solver <= GSF_NN_SOLVER_UNIPC; solver++)
        for (int steps = 1; steps <= 12; steps++) {
            gsf_nn_sampler sampler;
            const gsf_nn_sampler_desc desc = {(gsf_nn_solver)solver, steps, 0.0, 1};
            CHECK_OK(ctx, gsf_nn_make_sampler(ctx, &schedule, &desc, &sampler));
            float x = 0.8f;
            double y = 0.8, last = 0.0, m[2] = {0.0, 0.0};
            lambda_point p[2];
            memset(p, 0, sizeof p);
            for (int i = 0; i < sampler.count; i++) {
                const double bar = schedule.alpha_bar[sampler.timesteps[i]];
                const lambda_point here = lambda_at(bar);
                const lambda_point next = lambda_at(i + 1 < sampler.count ? schedule.alpha_bar[sampler.timesteps[i + 1]]
                                                                          : schedule.final_alpha_bar);
                const float v = (float)some_model(bar, (double)x);
                const double m_t = here.a * y - here.s * some_model(bar, y);
                if (solver == GSF_NN_SOLVER_UNIPC && i > 0) y = plain_corrector(i > 1 ? 2 : 1, here, p, last, m, m_t);
                p[1] = p[0];
                p[0] = here;
                m[1] = m[0];
                m[0] = m_t;
                last = y;
                y = plain_predictor(i > 0 && i + 1 < sampler.count ? 2 : 1, next, p, y, m);
                CHECK_OK(ctx, gsf_nn_step_sampler(ctx, &sampler, &v, &x, NULL));
                CHECK_NEAR(x, y, 3e-6);
            }
            gsf_nn_destroy_sampler(ctx, &sampler);
        }
    gsf_nn_destroy_schedule(ctx, &schedule);
}

// ---- time steps

static void test_timesteps(gsf_context* ctx, const gsf_nn_schedule* schedule) {
    int32_t t[1000], all[1000], count;
    for (int steps = 1; steps <= 1000; steps++) {
        CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, schedule, steps, 0.0, t, &count));
        int ok = count == steps && t[0] == 999 && t[steps - 1] >= 0;
        for (int i = 1; i < steps; i++) ok &= t[i] < t[i - 1];
        CHECK(ok);
    }
    // values at .5, where numpy's arithmetic decides (np.round(np.arange(1000, 0, -1000/48)) - 1)
    static const int32_t by_48[] = {999, 978, 957, 936, 916, 895, 874, 853};
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, schedule, 48, 0.0, t, &count));
    for (size_t i = 0; i < COUNT_OF(by_48); i++) CHECK(t[i] == by_48[i]);
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, schedule, 50, 1.0, all, &count));
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, schedule, 50, 0.6, t, &count)); // diffusers' get_timesteps: int(50 * 0.6)
    CHECK(count == 30 && memcmp(t, all + 20, 30 * sizeof *t) == 0);
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, schedule, 50, 0.39, t, &count));
    CHECK(count == 19 && t[0] == all[31] && t[18] == 19);
    static const double bad[] = {-0.1, 1.1, 0.01, NAN, INFINITY};
    for (size_t i = 0; i < COUNT_OF(bad); i++)
        CHECK_RESULT(ctx, gsf__nn_make_timesteps(ctx, schedule, 50, bad[i], t, &count), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf__nn_make_timesteps(ctx, schedule, 0, 1.0, t, &count), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf__nn_make_timesteps(ctx, schedule, 1001, 1.0, t, &count), GSF_ERROR_INVALID_ARGUMENT);

    gsf_nn_schedule other;
    gsf_nn_schedule_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.spacing = GSF_NN_SPACING_LEADING;
    desc.steps_offset = 1;
    CHECK_OK(ctx, gsf_nn_make_schedule(ctx, &desc, &other));
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, &other, 3, 1.0, t, &count));
    CHECK(count == 3 && t[0] == 667 && t[1] == 334 && t[2] == 1);
    CHECK_RESULT(ctx, gsf__nn_make_timesteps(ctx, &other, 1000, 1.0, t, &count), GSF_ERROR_INVALID_ARGUMENT);
    gsf_nn_destroy_schedule(ctx, &other);
    desc.spacing = GSF_NN_SPACING_LINSPACE;
    CHECK_OK(ctx, gsf_nn_make_schedule(ctx, &desc, &other));
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, &other, 4, 1.0, t, &count));
    CHECK(t[0] == 999 && t[1] == 666 && t[2] == 333 && t[3] == 0);
    // 832.5, 666, 499.5, ...: rounded half to even
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, &other, 7, 1.0, t, &count));
    CHECK(t[1] == 832 && t[2] == 666 && t[3] == 500 && t[4] == 333 && t[5] == 166 && t[6] == 0);
    CHECK_OK(ctx, gsf__nn_make_timesteps(ctx, &other, 1, 1.0, t, &count));
    CHECK(count == 1 && t[0] == 0);
    gsf_nn_destroy_schedule(ctx, &other);
}

// ---- configs

static void test_configs(gsf_context* ctx) {
    static const struct { const char* text; gsf_result result; const char* error; } cases[] = {
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false}", GSF_OK, ""},
        {"{\"clip_sample\":false}", GSF_ERROR_UNSUPPORTED, "prediction_type is epsilon, not v_prediction"},
        {"{\"prediction_type\":\"v_prediction\"}", GSF_ERROR_UNSUPPORTED, "clip_sample"},
        {"{\"prediction_type\":\"sample\",\"clip_sample\":false}", GSF_ERROR_UNSUPPORTED,
         "prediction_type is sample, not v_prediction"},
        {"{\"prediction_type\":7}", GSF_ERROR_FORMAT, "prediction_type is not a string"},
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"thresholding\":true}", GSF_ERROR_UNSUPPORTED,
         "thresholding"},
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"trained_betas\":[0.1]}", GSF_ERROR_UNSUPPORTED,
         "trained_betas"},
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"beta_schedule\":\"squaredcos_cap_v2\"}",
         GSF_ERROR_UNSUPPORTED, "squaredcos_cap_v2"},
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"timestep_spacing\":\"random\"}",
         GSF_ERROR_UNSUPPORTED, "random"},
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"beta_start\":0.5,\"beta_end\":0.1}",
         GSF_ERROR_FORMAT, "beta_end is not a number from 0.5"},
        {"{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"num_train_timesteps\":1}", GSF_ERROR_FORMAT,
         "num_train_timesteps"},
        {"[]", GSF_ERROR_FORMAT, "not an object"},
        {"{", GSF_ERROR_FORMAT, "sched.json:1"},
    };
    for (size_t i = 0; i < COUNT_OF(cases); i++) {
        gsf_nn_schedule schedule;
        CHECK_RESULT(ctx, gsf_nn_parse_schedule(ctx, "sched.json", cases[i].text, strlen(cases[i].text), &schedule),
                     cases[i].result);
        if (!CHECK(cases[i].result == GSF_OK || strstr(ctx->error, cases[i].error) != NULL))
            fprintf(stderr, "  \"%s\" is not in \"%s\"\n", cases[i].error, ctx->error);
        if (cases[i].result == GSF_OK) { // diffusers' own defaults
            CHECK(schedule.desc.train_steps == 1000 && schedule.desc.spacing == GSF_NN_SPACING_LEADING);
            CHECK(schedule.desc.linear_betas && schedule.desc.no_zero_snr && schedule.final_alpha_bar == 1.0);
            CHECK_NEAR(schedule.alpha_bar[0], 0.9999, 1e-7);
            CHECK_NEAR(schedule.alpha_bar[999], 4.0358e-5, 1e-8); // of the usual linear schedule
        } else {
            CHECK(schedule.alpha_bar == NULL);
        }
        gsf_nn_destroy_schedule(ctx, &schedule);
    }
    gsf_nn_schedule schedule;
    for (int fault = 0; fault < 6; fault++) {
        gsf_nn_schedule_desc desc;
        memset(&desc, 0, sizeof desc);
        if (fault == 0) desc.train_steps = -1;
        if (fault == 1) desc.beta_end = 1.0;
        if (fault == 2) desc.beta_start = NAN;
        if (fault == 3) desc.snr_shift_scale = -1.0;
        if (fault == 4) desc.steps_offset = 1000;
        if (fault == 5) desc.spacing = (gsf_nn_spacing)3;
        CHECK_RESULT(ctx, gsf_nn_make_schedule(ctx, &desc, &schedule), GSF_ERROR_INVALID_ARGUMENT);
    }
    gsf_nn_schedule_desc still; // betas so small that 1 - beta rounds to 1
    memset(&still, 0, sizeof still);
    still.beta_start = still.beta_end = 1e-20;
    CHECK_RESULT(ctx, gsf_nn_make_schedule(ctx, &still, &schedule), GSF_ERROR_DEGENERATE);
    CHECK(strstr(ctx->error, "betas from 1e-20") != NULL && schedule.alpha_bar == NULL);
    CHECK_RESULT(ctx, gsf_nn_load_schedule(ctx, test_scratch("absent.json"), &schedule), GSF_ERROR_NOT_FOUND);
}

// Betas so large that abar reaches 0 long before the last step.
static void test_steep_config(gsf_context* ctx) {
    static const char text[] = "{\"prediction_type\":\"v_prediction\",\"clip_sample\":false,\"beta_start\":0.9,"
                               "\"beta_end\":0.99,\"rescale_betas_zero_snr\":true}";
    gsf_nn_schedule schedule;
    if (!CHECK_OK(ctx, gsf_nn_parse_schedule(ctx, "sched.json", text, strlen(text), &schedule))) return;
    const double* bar = schedule.alpha_bar;
    CHECK_NEAR(bar[0], 0.1, 1e-15);
    CHECK_NEAR(bar[1], 0.1 * (0.1 - 0.09 / 999.0), 1e-16);
    const int32_t last = schedule.desc.train_steps - 1;
    for (int32_t i = 1; i <= last; i++) CHECK(bar[i] < bar[i - 1] || (bar[i] == 0.0 && bar[i - 1] == 0.0));
    CHECK(bar[last] == 0.0);
    gsf_nn_destroy_schedule(ctx, &schedule);
}

// ---- samplers

static void fill_noise(float* x, size_t count, uint64_t stream) {
    for (size_t i = 0; i < count; i++) x[i] = (float)gsf_draw_normal(7, stream, i);
}

// another order of work, other workers
static void backward_for(void* user, size_t chunks, gsf_chunk_fn body, void* arg) {
    for (size_t i = chunks; i-- > 0;) body(arg, i, (int)(i % 3));
    ++*(int*)user;
}

// The same bits with another order of work, and when a run resumes from the state that a checkpoint stores.
static void test_repeatable(gsf_context* ctx, const gsf_nn_schedule* schedule) {
    enum { COUNT = 2 * 65536 + 77, STEPS = 7, STOP = 4 };
    float* x[3];
    float* v = (float*)malloc(COUNT * sizeof(float));
    gsf_context other;
    int calls = 0;
    test_context_zero(&other);
    other.parallel.for_fn = backward_for;
    other.parallel.worker_count = 3;
    other.parallel.user = &calls;
    CHECK_OK(ctx, gsf_init_context(&other));
    for (int k = 0; k < 3; k++) x[k] = (float*)malloc(COUNT * sizeof(float));
    for (int solver = 0; solver < 3; solver++) {
        const gsf_nn_sampler_desc desc = {(gsf_nn_solver)solver, STEPS, 0.0, COUNT};
        gsf_nn_sampler s[3];
        for (int k = 0; k < 3; k++) {
            CHECK_OK(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s[k]));
            fill_noise(x[k], COUNT, 1);
        }
        for (int i = 0; i < STEPS; i++) {
            if (i == STOP) { // x[2] continues in a new sampler
                gsf_nn_sampler resumed;
                CHECK_OK(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &resumed));
                CHECK(resumed.memory_count == s[2].memory_count);
                memcpy(resumed.memory, s[2].memory, s[2].memory_count * sizeof(float));
                resumed.index = s[2].index;
                gsf_nn_destroy_sampler(ctx, &s[2]);
                s[2] = resumed;
            }
            fill_noise(v, COUNT, (uint64_t)i + 2);
            for (int k = 0; k < 3; k++) CHECK_OK(ctx, gsf_nn_step_sampler(k == 1 ? &other : ctx, &s[k], v, x[k], NULL));
        }
        CHECK(memcmp(x[0], x[1], COUNT * sizeof(float)) == 0);
        CHECK(memcmp(x[0], x[2], COUNT * sizeof(float)) == 0);
        for (int k = 0; k < 3; k++) gsf_nn_destroy_sampler(ctx, &s[k]);
    }
    CHECK(calls > 0);
    for (int k = 0; k < 3; k++) free(x[k]);
    free(v);
}

static void test_bad_samplers(gsf_context* ctx, const gsf_nn_schedule* schedule) {
    gsf_nn_sampler s;
    gsf_nn_sampler_desc desc = {GSF_NN_SOLVER_UNIPC, 5, 0.0, 3};
    float x[3] = {1.0f, 2.0f, 3.0f}, v[3] = {0.0f, 0.0f, 0.0f};
    CHECK_OK(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s));
    CHECK_OK(ctx, gsf_nn_step_sampler(ctx, &s, v, x, NULL));
    v[1] = NAN;
    CHECK_RESULT(ctx, gsf_nn_step_sampler(ctx, &s, v, x, NULL), GSF_ERROR_NUMERIC);
    CHECK(strstr(ctx->error, "step 1 (time 799): latent 1 of 3") != NULL && s.index == 1);
    v[1] = INFINITY;
    CHECK_RESULT(ctx, gsf_nn_step_sampler(ctx, &s, v, x, NULL), GSF_ERROR_NUMERIC);
    gsf_nn_destroy_sampler(ctx, &s);
    desc.steps = 1001;
    CHECK_RESULT(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s), GSF_ERROR_INVALID_ARGUMENT);
    desc.steps = 5;
    desc.solver = (gsf_nn_solver)3;
    CHECK_RESULT(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s), GSF_ERROR_INVALID_ARGUMENT);
    desc.solver = GSF_NN_SOLVER_UNIPC;
    desc.strength = 2.0;
    CHECK_RESULT(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s), GSF_ERROR_INVALID_ARGUMENT);
    desc.strength = 0.0;
    desc.value_count = SIZE_MAX / 2;
    CHECK_RESULT(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s), GSF_ERROR_INVALID_ARGUMENT);
    CHECK(s.timesteps == NULL && s.memory == NULL);
    desc.value_count = SIZE_MAX / 8;
    CHECK_RESULT(ctx, gsf_nn_make_sampler(ctx, schedule, &desc, &s), GSF_ERROR_OUT_OF_MEMORY);
    CHECK(s.timesteps == NULL && s.memory == NULL);
}

static void test_schedule_memory(void) {
    for (size_t k = 1; k <= 4; k++) {
        gsf_context ctx;
        gsf_nn_schedule schedule;
        gsf_nn_sampler sampler;
        counter c;
        memset(&c, 0, sizeof c);
        memset(&sampler, 0, sizeof sampler);
        test_context_zero(&ctx);
        count_memory(&ctx, &c);
        CHECK_OK(&ctx, gsf_init_context(&ctx));
        c.fail_at = k;
        gsf_result r = gsf_nn_make_schedule(&ctx, NULL, &schedule);
        const gsf_nn_sampler_desc desc = {GSF_NN_SOLVER_DPMPP_2M, 0, 0.0, 10};
        if (r == GSF_OK) r = gsf_nn_make_sampler(&ctx, &schedule, &desc, &sampler);
        CHECK_RESULT(&ctx, r, k < 4 ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK);
        CHECK(k < 4 || (sampler.count == 50 && sampler.memory_count == 10));
        gsf_nn_destroy_sampler(&ctx, &sampler);
        gsf_nn_destroy_schedule(&ctx, &schedule);
        CHECK(c.live == 0);
    }
}

// ---- positions: what the golden tables do not cover

static void test_positions(gsf_context* ctx) {
    gsf__nn_rope_desc d = {2, 3, 4, 3, 4, 16, 0.0};
    float c[2 * 3 * 4 * 16], s[2 * 3 * 4 * 16], same[2 * 3 * 4 * 16], out[2 * 3 * 4 * 16];
    CHECK_OK(ctx, gsf__nn_make_rope(ctx, &d, c, s));
    d.theta = 10000.0;
    CHECK_OK(ctx, gsf__nn_make_rope(ctx, &d, same, out));
    CHECK(memcmp(c, same, sizeof c) == 0 && memcmp(s, out, sizeof s) == 0);
    for (size_t i = 0; i < COUNT_OF(c); i += 2) CHECK(c[i] == c[i + 1] && s[i] == s[i + 1]);
    for (size_t i = 0; i < COUNT_OF(c); i++) CHECK_NEAR(c[i] * c[i] + s[i] * s[i], 1.0f, 1e-6);
    const size_t row = ((1 * 3 + 2) * 4 + 3) * 16; // frame 1, row 2, column 3
    CHECK_NEAR(s[row], sin(1.0), 1e-7);
    CHECK_NEAR(s[row + 4], sin(2.0), 1e-7);
    CHECK_NEAR(s[row + 10], sin(3.0), 1e-7);
    CHECK_OK(ctx, gsf__nn_make_sincos(ctx, 2, 3, 4, 16, 0.0, 0.0, out));
    CHECK_NEAR(out[row], sin(1.0), 1e-7);     // time
    CHECK_NEAR(out[row + 4], sin(3.0), 1e-7); // column
    CHECK_NEAR(out[row + 10], sin(2.0), 1e-7); // row
    CHECK_NEAR(out[row + 13], cos(2.0), 1e-7);
    d.head_dim = 24;
    CHECK_RESULT(ctx, gsf__nn_make_rope(ctx, &d, c, s), GSF_ERROR_UNSUPPORTED);
    d.head_dim = 16;
    d.frames = 0;
    CHECK_RESULT(ctx, gsf__nn_make_rope(ctx, &d, c, s), GSF_ERROR_INVALID_ARGUMENT);
    d.frames = 1 << 20;
    d.height = 1 << 20;
    CHECK_RESULT(ctx, gsf__nn_make_rope(ctx, &d, c, s), GSF_ERROR_INVALID_ARGUMENT);
    d.frames = d.height = 1;
    d.base_width = 0;
    CHECK_RESULT(ctx, gsf__nn_make_rope(ctx, &d, c, s), GSF_ERROR_INVALID_ARGUMENT);
    CHECK_RESULT(ctx, gsf__nn_make_sincos(ctx, 1, 1, 1, 8, 1.0, 1.0, out), GSF_ERROR_UNSUPPORTED);
    CHECK_RESULT(ctx, gsf__nn_make_sincos(ctx, 1, 1, 1, 16, -1.0, 1.0, out), GSF_ERROR_INVALID_ARGUMENT);
    gsf__nn_embed_timestep(1.0, 5, out); // odd: a last zero
    CHECK_NEAR(out[0], cos(1.0), 1e-7);
    CHECK_NEAR(out[2], sin(1.0), 1e-7);
    CHECK_NEAR(out[1], cos(0.01), 1e-7);
    CHECK(out[4] == 0.0f);
}

int main(void) {
    gsf_context ctx;
    gsf_nn_schedule schedule;
    test_context_init(&ctx);
    CHECK_OK(&ctx, gsf_nn_make_schedule(&ctx, NULL, &schedule));
    CHECK(schedule.alpha_bar[999] == 0.0 && schedule.final_alpha_bar == 1.0);
    test_schedule_order(&ctx, &schedule);
    test_formulas(&ctx);
    test_timesteps(&ctx, &schedule);
    test_configs(&ctx);
    test_steep_config(&ctx);
    test_repeatable(&ctx, &schedule);
    test_bad_samplers(&ctx, &schedule);
    test_schedule_memory();
    test_positions(&ctx);
    gsf_nn_destroy_schedule(&ctx, &schedule);
    return test_report();
}
