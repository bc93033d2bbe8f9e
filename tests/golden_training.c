// Training of the transformer against golden data made with PyTorch: GSF_GOLDEN/restorer/training (see its README). Loss,
// gradients and three updates by AdamW; the same bits for any number of workers. GSF_TEST_VERBOSE=1 prints every error.
#define GSF_NN_TRAINING
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_nn.h"

#include "restorer_golden.h"
#include "test_hooks.h"

// Relative L2; PyTorch's own float32 run is within 1.5e-6 and 1.4e-5 of the expected values.
static const double gradient_bar = 3e-6, loss_bar = 1e-6;
static const double change_bar = 1e-4; // weights near 1 change by 1e-3, where float32 resolves 6e-5 of it
// attn1.norm_k.bias: rotation and text leave it gradients a hundredth of the others', whose rounding Adam magnifies
static const double small_change_bar = 1e-3;

enum { STEPS = 3 };

typedef struct training {
    gsf_context* ctx;
    gsf_nn_transformer net;
    gsf_nn_schedule schedule;
    gsf__nn_params params;
    gsf__dit_train_desc desc;
    test_tensors inputs, expected;
    float* data[8]; // tensors of `inputs`, freed at the end
    size_t used;
    float* first;   // the values before the first update
} training;

static const float* input(training* t, const char* name, test_tensor* shape) {
    return t->data[t->used++] = golden_floats(&t->inputs, name, shape);
}

// The part of a tensor that the file holds: of large ones, every few rows and columns.
static size_t slice(const gsf_nn_tensor* tensor, const float* values, float* out) {
    const int64_t rows = tensor->rank ? tensor->shape[0] : 1, columns = tensor->count / rows;
    const int whole = tensor->count <= 2048;
    const int64_t down = whole || rows < 32 ? 1 : rows / 16, across = whole || columns < 64 ? 1 : columns / 32;
    size_t n = 0;
    for (int64_t r = 0; r < rows; r += down)
        for (int64_t c = 0; c < columns; c += across) out[n++] = values[r * columns + c];
    return n;
}

static int is_ill_conditioned(const char* name) { // its gradient is zero: a constant added to all keys
    return strstr(name, "attn_cross.norm_k.bias") != NULL;
}

// Compares a copy of all parameters, prefix "grad" or "delta3", with the file's slices; returns how many there were.
static int compare_parameters(const training* t, const char* prefix, const float* values, double bar) {
    float* part = (float*)malloc(1 << 20);
    int found = 0;
    for (size_t i = 0; i < t->params.weights->tensor_count; i++) {
        const gsf_nn_tensor* tensor = &t->params.weights->tensors[i];
        char name[200];
        snprintf(name, sizeof name, "%s.%s", prefix, tensor->name);
        test_tensor want = test_find_tensor(&t->expected, name);
        if (!want.v) continue;
        found++;
        if (!CHECK(t->params.at[i] >= 0)) continue;
        const size_t n = slice(tensor, values + t->params.at[i], part);
        if (!CHECK(n == want.count)) fprintf(stderr, "    %s: %zu values, expected %zu\n", name, n, want.count);
        else if (prefix[0] == 'd' && strstr(name, "attn1.norm_k.bias")) check_rel_l2(name, part, want.v, n, small_change_bar);
        else if (!is_ill_conditioned(tensor->name)) check_rel_l2(name, part, want.v, n, bar);
        else if (prefix[0] == 'g') test_compare_floats(name, part, want.v, n, 2e-8);
        test_free_tensor(&want);
    }
    free(part);
    return found;
}

// L2 norms of all parameters, in the order of run.json's list of names.
static void compare_norms(const training* t, const char* what, const float* values, double bar) {
    size_t size, count, k = 0;
    char* run = test_read_file(test_golden("restorer/training/run.json"), &size);
    double* want = golden_doubles(&t->expected, what, &count);
    const char* p = strstr(run, "\"parameter_names\"");
    for (p = p ? strchr(p, '[') : NULL; p && *p && *p != ']' && k < count;) {
        const char *begin = strchr(p, '"') + 1, *end = strchr(begin, '"');
        char name[200];
        snprintf(name, sizeof name, "%.*s", (int)(end - begin), begin);
        const gsf_nn_tensor* tensor = gsf_nn_find_tensor(t->params.weights, name);
        if (CHECK(tensor != NULL) && !is_ill_conditioned(name)) {
            const float* v = values + t->params.at[tensor - t->params.weights->tensors];
            double square = 0.0;
            for (int64_t i = 0; i < tensor->count; i++) square += (double)v[i] * (double)v[i];
            if (!CHECK_NEAR(sqrt(square), want[k], bar * want[k])) fprintf(stderr, "    %s: %s\n", what, name);
        }
        k++;
        p = end + 1;
    }
    CHECK(k == count && count > 0);
    free(want);
    free(run);
}

static void open_training(training* t, gsf_context* ctx) {
    memset(t, 0, sizeof *t);
    t->ctx = ctx;
    CHECK_OK(ctx, gsf_nn_load_transformer(ctx, test_golden("restorer/model/transformer"), &t->net));
    CHECK_OK(ctx, gsf_nn_load_schedule(ctx, test_golden("restorer/model/scheduler/scheduler_config.json"), &t->schedule));
    CHECK_OK(ctx, gsf__nn_make_params(ctx, &t->net.weights, gsf__dit_trains, 1, &t->params));
    t->inputs = test_open_tensors(test_golden("restorer/training/inputs.safetensors"));
    t->expected = test_open_tensors(test_golden("restorer/training/expected.safetensors"));
    test_tensor shape, images, text_shape;
    const float *latents = input(t, "latents", &shape), *control = input(t, "control_latents", NULL);
    const float *noise = input(t, "noise", NULL), *text = input(t, "encoder_hidden_states", &text_shape);
    const float *dino = input(t, "dino_latents", &images), *vggt = input(t, "vggt_latents", NULL);
    double* times = golden_doubles(&t->inputs, "timesteps", NULL);
    const size_t batch = shape.dim[0], count = shape.count / batch, tokens = images.dim[0] * images.dim[1] / batch;
    gsf__dit_example* e = (gsf__dit_example*)calloc(batch, sizeof *e);
    for (size_t b = 0; b < batch; b++) {
        e[b].latents = latents + b * count;
        e[b].control = control + b * count;
        e[b].noise = noise + b * count;
        e[b].text = text + b * (text_shape.count / batch);
        e[b].dino = dino + b * tokens * (size_t)t->net.dino_channels;
        e[b].vggt = vggt + b * tokens * (size_t)t->net.vggt_channels;
        e[b].reference_tokens = (int64_t)tokens;
        e[b].timestep = (int32_t)times[b];
    }
    free(times);
    t->desc.frames = (int32_t)shape.dim[1];
    t->desc.height = (int32_t)shape.dim[3];
    t->desc.width = (int32_t)shape.dim[4];
    t->desc.batch = (int32_t)batch;
    t->desc.examples = e;
    t->desc.schedule = &t->schedule;
    t->first = (float*)malloc((size_t)t->params.count * sizeof(float));
    memcpy(t->first, t->params.value, (size_t)t->params.count * sizeof(float));
}

static void close_training(training* t) {
    while (t->used) free(t->data[--t->used]);
    free((void*)(uintptr_t)t->desc.examples);
    free(t->first);
    test_close_tensors(&t->inputs);
    test_close_tensors(&t->expected);
    gsf__nn_destroy_params(t->ctx, &t->params);
    gsf_nn_destroy_schedule(t->ctx, &t->schedule);
    gsf_nn_destroy_transformer(t->ctx, &t->net);
}

// Three updates on the same batch; losses: before each update and after the last. With `compare`, against the file.
static void train(training* t, double losses[STEPS + 1], int compare) {
    size_t count;
    double *lr = golden_doubles(&t->expected, "lr", NULL), *norms = golden_doubles(&t->expected, "grad_total_norm_f64", NULL);
    test_tensor pred = test_get_tensor(&t->expected, "pred");
    gsf__nn_adam_desc adam;
    memset(&adam, 0, sizeof adam); // run.json
    adam.lr = 1e-3;
    adam.weight_decay = 0.01;
    adam.max_norm = 1.0;
    adam.warmup = 2;
    adam.average = 0.5;
    for (int i = 0; i <= STEPS; i++) {
        double norm = 0.0;
        float* out = (float*)malloc(pred.count * sizeof(float));
        t->desc.predicted = out;
        if (!CHECK_OK(t->ctx, gsf__nn_train_transformer(t->ctx, &t->net, &t->params, &t->desc, &losses[i]))) exit(2);
        if (i == 0 && compare) {
            check_rel_l2("pred", out, pred.v, pred.count, 2e-6);
            CHECK(compare_parameters(t, "grad", t->params.grad, gradient_bar) > 50);
            compare_norms(t, "grad_l2_all", t->params.grad, gradient_bar);
        }
        free(out);
        if (i == STEPS) break;
        CHECK_NEAR(gsf__nn_adam_rate(&adam, t->params.step), lr[i], 1e-15);
        CHECK_OK(t->ctx, gsf__nn_step_adam(t->ctx, &t->params, &adam, &norm));
        if (compare) CHECK_NEAR(norm, norms[i], 1e-5 * norms[i]);
    }
    if (compare) {
        double* want = golden_doubles(&t->expected, "loss_f64", &count);
        float* change = (float*)malloc((size_t)t->params.count * sizeof(float));
        CHECK(count == STEPS + 1);
        for (int i = 0; i <= STEPS; i++) CHECK_NEAR(losses[i], want[i], loss_bar * want[i]);
        for (int64_t i = 0; i < t->params.count; i++) change[i] = t->params.value[i] - t->first[i];
        CHECK(compare_parameters(t, "delta3", change, change_bar) > 50);
        compare_norms(t, "delta3_l2_all", change, change_bar);
        free(change);
        free(want);
    }
    free(lr);
    free(norms);
    test_free_tensor(&pred);
}

// Two updates in one go are those of one, a file, and one more.
static void test_resume(gsf_context* ctx) {
    const char* path = test_scratch("training.safetensors");
    gsf__nn_adam_desc adam;
    training whole, first, second;
    double loss;
    memset(&adam, 0, sizeof adam);
    adam.lr = 1e-3;
    adam.average = 0.9;
    open_training(&whole, ctx);
    open_training(&first, ctx);
    open_training(&second, ctx);
    for (int i = 0; i < 2; i++) {
        CHECK_OK(ctx, gsf__nn_train_transformer(ctx, &whole.net, &whole.params, &whole.desc, &loss));
        CHECK_OK(ctx, gsf__nn_step_adam(ctx, &whole.params, &adam, NULL));
    }
    CHECK_OK(ctx, gsf__nn_train_transformer(ctx, &first.net, &first.params, &first.desc, &loss));
    CHECK_OK(ctx, gsf__nn_step_adam(ctx, &first.params, &adam, NULL));
    CHECK_OK(ctx, gsf__nn_save_params(ctx, &first.params, GSF__NN_SAVE_STATE, path));
    CHECK_OK(ctx, gsf__nn_load_params(ctx, &second.params, path));
    CHECK(second.params.step == 1);
    CHECK_OK(ctx, gsf__nn_train_transformer(ctx, &second.net, &second.params, &second.desc, &loss));
    CHECK_OK(ctx, gsf__nn_step_adam(ctx, &second.params, &adam, NULL));
    const size_t bytes = (size_t)whole.params.count * sizeof(float);
    CHECK(memcmp(second.params.value, whole.params.value, bytes) == 0);
    CHECK(memcmp(second.params.m, whole.params.m, bytes) == 0);
    CHECK(memcmp(second.params.v, whole.params.v, bytes) == 0);
    CHECK(memcmp(second.params.average, whole.params.average, bytes) == 0);
    // as a model: the moving averages under the names and shapes of the network
    gsf_nn_weights file;
    CHECK_OK(ctx, gsf__nn_save_params(ctx, &whole.params, GSF__NN_SAVE_AVERAGE, path));
    CHECK_OK(ctx, gsf_nn_load_weights(ctx, path, NULL, &file));
    CHECK(file.tensor_count == whole.params.weights->tensor_count);
    const gsf_nn_tensor *saved = gsf_nn_find_tensor(&file, "proj_out.weight");
    const gsf_nn_tensor *mine = gsf_nn_find_tensor(whole.params.weights, "proj_out.weight");
    CHECK(saved && memcmp(saved->data, whole.params.average + whole.params.at[mine - whole.params.weights->tensors],
                          (size_t)mine->count * sizeof(float)) == 0);
    gsf_nn_destroy_weights(ctx, &file);
    CHECK_RESULT(ctx, gsf__nn_load_params(ctx, &second.params, path), GSF_ERROR_FORMAT); // it has no state
    CHECK(memcmp(second.params.value, whole.params.value, bytes) == 0);
    close_training(&whole);
    close_training(&first);
    close_training(&second);
}

// A step with bf16: within its rounding of that in float32, and the same bits with other workers. Where products are not
// rounded, the loss is that in float32: only the inputs kept for the way back are rounded.
static void test_bf16(gsf_context* ctx) {
    training plain, rounded, again;
    gsf_context others;
    memset(&others, 0, sizeof others);
    others.cpu_level = ctx->cpu_level; // by default, another one may be chosen than the highest
    work_backwards(&others);
    CHECK_OK(&others, gsf_init_context(&others));
    double losses[3], error = 0.0, size = 0.0;
    training* const all[] = {&plain, &rounded, &again};
    for (int i = 0; i < 3; i++) {
        open_training(all[i], i == 2 ? &others : ctx);
        all[i]->net.bf16 = i > 0;
        CHECK_OK(all[i]->ctx, gsf__nn_train_transformer(all[i]->ctx, &all[i]->net, &all[i]->params, &all[i]->desc, &losses[i]));
    }
    for (int64_t i = 0; i < plain.params.count; i++) {
        const double g = plain.params.grad[i], d = (double)rounded.params.grad[i] - g;
        error += d * d;
        size += g * g;
    }
    error = sqrt(error / size);
    const gsf__dit_train_cost all_kept = gsf__nn_query_training(ctx, &plain.net, 1, 0, 3, 8, 8, 4);
    const gsf__dit_train_cost half_kept = gsf__nn_query_training(ctx, &rounded.net, 1, 0, 3, 8, 8, 4);
    CHECK(half_kept.kept > 0.0 && all_kept.kept == 2.0 * half_kept.kept);
    CHECK(all_kept.work - half_kept.work <= 4.0 && half_kept.work - all_kept.work <= 4.0);
    printf("bf16: loss %.6f (%.6f in float32), gradients differ by %.1e\n", losses[1], losses[0], error);
    CHECK_NEAR(losses[1], losses[0], 1e-2 * losses[0]);
    CHECK_NEAR(error, 0.0, 3e-2);
    const int rounds = ctx->cpu_level == GSF_CPU_AVX512_BF16 || ctx->cpu_level == GSF_CPU_AMX;
    CHECK(rounds ? losses[1] != losses[0] && error > 1e-4 : losses[1] == losses[0] && error > 0.0 && error < 2e-3);
    CHECK(losses[1] == losses[2]);
    CHECK(memcmp(rounded.params.grad, again.params.grad, (size_t)plain.params.count * sizeof(float)) == 0);
    for (int i = 0; i < 3; i++) close_training(all[i]);
}

// AdamW, clipping, a cosine and the mean of accumulated gradients in double, for sizes around a vector and a chunk.
static void test_adam(gsf_context* ctx) {
    static const int64_t sizes[] = {1, 7, 17, 33000};
    uint64_t seed = 5;
    for (size_t s = 0; s < GSF__COUNT(sizes); s++) {
        const int64_t n = sizes[s];
        gsf__nn_params p;
        const gsf__nn_adam_desc d = {0.01, 0.8, 0.95, 1e-6, 0.1, s % 2 ? 0.5 : 0.0, 0.75, 2, 9, 4};
        float* memory = (float*)calloc((size_t)(5 * n), sizeof(float));
        double *x = (double*)calloc((size_t)(4 * n), sizeof(double)), *m = x + n, *v = m + n, *average = v + n;
        memset(&p, 0, sizeof p);
        p.count = n;
        p.value = memory;
        p.grad = p.value + n;
        p.m = p.grad + n;
        p.v = p.m + n;
        p.average = p.v + n;
        for (int64_t i = 0; i < n; i++) {
            p.value[i] = p.average[i] = (float)test_random_in(&seed, -1, 1);
            x[i] = average[i] = (double)p.value[i];
        }
        for (int step = 0; step < 10; step++) {
            double square = 0.0, norm;
            double* g = (double*)malloc((size_t)n * sizeof(double));
            for (int64_t i = 0; i < n; i++) {
                g[i] = (double)(p.grad[i] = (float)test_random_in(&seed, -3, 3)) / 4.0;
                square += g[i] * g[i];
            }
            const double clip = s % 2 && sqrt(square) > 0.5 ? 0.5 / (sqrt(square) + 1e-6) : 1.0;
            const double lr = step < 2 ? 0.01 * step / 2.0 : step >= 9 ? 0.0
                            : 0.005 * (1.0 + cos(3.14159265358979 * (step - 2) / 7.0));
            for (int64_t i = 0; i < n; i++) {
                m[i] = 0.8 * m[i] + 0.2 * clip * g[i];
                v[i] = 0.95 * v[i] + 0.05 * clip * g[i] * clip * g[i];
                x[i] *= 1.0 - lr * 0.1;
                x[i] -= lr * m[i] / (1.0 - pow(0.8, step + 1)) / (sqrt(v[i] / (1.0 - pow(0.95, step + 1))) + 1e-6);
                average[i] = 0.75 * average[i] + 0.25 * x[i];
            }
            CHECK_OK(ctx, gsf__nn_step_adam(ctx, &p, &d, &norm));
            CHECK_NEAR(norm, sqrt(square), 1e-6 * sqrt(square));
            CHECK(p.grad[0] == 0.0f && p.grad[n - 1] == 0.0f);
            free(g);
        }
        test_compare_floats("adam: values", p.value, x, (size_t)n, 1e-6);
        test_compare_floats("adam: averages", p.average, average, (size_t)n, 1e-6);
        free(memory);
        free(x);
    }
}

// Every failing allocation among the first, then some: an error without a leak. Refused models and examples.
static void test_errors(void) {
    gsf_context ctx;
    counter count;
    training t;
    double loss;
    test_context_zero(&ctx);
    memset(&count, 0, sizeof count);
    count_memory(&ctx, &count);
    CHECK_OK(&ctx, gsf_init_context(&ctx));
    open_training(&t, &ctx);
    t.desc.batch = 1;
    const size_t live = count.live;
    for (size_t k = 1;; k += k < 30 ? 1 : 17) {
        count.calls = 0;
        count.fail_at = k;
        const gsf_result result = gsf__nn_train_transformer(&ctx, &t.net, &t.params, &t.desc, &loss);
        CHECK(count.live == live);
        if (result == GSF_OK) break;
        if (!CHECK(result == GSF_ERROR_OUT_OF_MEMORY)) break;
    }
    count.fail_at = 0;
    gsf__dit_example* e = (gsf__dit_example*)(uintptr_t)t.desc.examples;
    e->timestep = 1000;
    CHECK_RESULT(&ctx, gsf__nn_train_transformer(&ctx, &t.net, &t.params, &t.desc, &loss), GSF_ERROR_INVALID_ARGUMENT);
    e->timestep = 0;
    e->dino = NULL; // vggt alone is the ablation
    CHECK_OK(&ctx, gsf__nn_train_transformer(&ctx, &t.net, &t.params, &t.desc, &loss));
    e->vggt = NULL;
    CHECK_RESULT(&ctx, gsf__nn_train_transformer(&ctx, &t.net, &t.params, &t.desc, &loss), GSF_ERROR_INVALID_ARGUMENT);
    e->reference_tokens = 0;
    CHECK_OK(&ctx, gsf__nn_train_transformer(&ctx, &t.net, &t.params, &t.desc, &loss));
    const gsf__nn_adam_desc adam = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0};
    const float before = t.params.value[7];
    t.params.grad[5] = NAN;
    CHECK_RESULT(&ctx, gsf__nn_step_adam(&ctx, &t.params, &adam, NULL), GSF_ERROR_NUMERIC);
    CHECK(t.params.step == 0 && t.params.value[7] == before);
    close_training(&t);
    CHECK(count.live == 0);
}

int main(void) {
    gsf_context ctx, others;
    training t, again;
    double losses[STEPS + 1], same[STEPS + 1];
    test_context_init(&ctx);
    open_training(&t, &ctx);
    train(&t, losses, 1);
    test_context_zero(&others);
    work_backwards(&others);
    CHECK_OK(&others, gsf_init_context(&others));
    open_training(&again, &others);
    train(&again, same, 0);
    CHECK(memcmp(losses, same, sizeof losses) == 0);
    CHECK(memcmp(t.params.value, again.params.value, (size_t)t.params.count * sizeof(float)) == 0);
    CHECK(memcmp(t.params.average, again.params.average, (size_t)t.params.count * sizeof(float)) == 0);
    printf("loss %.6f %.6f %.6f %.6f\n", losses[0], losses[1], losses[2], losses[3]);
    close_training(&t);
    close_training(&again);
    test_resume(&ctx);
    test_bf16(&ctx);
    for (int level = GSF_CPU_SCALAR; level <= (int)ctx.cpu_level; level++) {
        gsf_context at;
        memset(&at, 0, sizeof at);
        at.cpu_level = (gsf_cpu_level)level;
        CHECK_OK(&at, gsf_init_context(&at));
        test_adam(&at);
    }
    test_errors();
    return test_report();
}
