// restorer_numerics.h - activations, norms, attention and half floats against restorer/numerics; matrix products are in
// restorer_linear.h. Tolerances are twice the reference's own float32 errors from the README, except that norms, which
// sum in double, must do better.

static gsf_context numerics_ctx;

// Finds the next name in the file's header that begins with `prefix` and ends with `suffix`; `name` receives the part
// between.
static int numerics_next(const test_tensors* file, const char* prefix, const char* suffix, size_t* at, char name[64]) {
    uint64_t header;
    memcpy(&header, file->data, 8);
    const size_t before = strlen(prefix), after = strlen(suffix), end = 8 + (size_t)header;
    for (size_t i = *at ? *at : 8; i + 1 < end; i++) {
        if (file->data[i] != '"' || i + 1 + before > end || memcmp(file->data + i + 1, prefix, before) != 0) continue;
        const char* start = file->data + i + 1 + before;
        const char* quote = (const char*)memchr(start, '"', end - i - 1 - before);
        if (!quote || (size_t)(quote - start) < after || memcmp(quote - after, suffix, after) != 0) continue;
        snprintf(name, 64, "%.*s", (int)((size_t)(quote - start) - after), start);
        *at = (size_t)(quote - file->data) + 1;
        return 1;
    }
    return 0;
}

static test_tensor numerics_get(const test_tensors* file, const char* group, const char* name, const char* part) {
    char label[160];
    snprintf(label, sizeof label, "%s.%s.%s", group, name, part);
    return test_get_tensor(file, label);
}

static float* numerics_floats(const test_tensors* file, const char* group, const char* name, const char* part,
                              test_tensor* shape) {
    char label[160];
    snprintf(label, sizeof label, "%s.%s.%s", group, name, part);
    return golden_floats(file, label, shape);
}

// ---- attention -----------------------------------------------------------------

// (heads, rows, dim): frees x
static float* numerics_to_columns(const float* x, int64_t heads, int64_t rows, int64_t dim) {
    float* out = (float*)malloc((size_t)(heads * rows * dim) * sizeof(float));
    for (int64_t h = 0; h < heads; h++)
        for (int64_t r = 0; r < rows; r++)
            memcpy(out + (r * heads + h) * dim, x + (h * rows + r) * dim, (size_t)dim * sizeof(float));
    free((void*)(uintptr_t)x);
    return out;
}

// Largest difference between two logits of one query; q (heads, queries, dim), k (heads, keys, dim).
static double numerics_logit_spread(const float* q, const float* k, int64_t heads, int64_t queries, int64_t keys,
                                    int64_t dim) {
    double spread = 0.0;
    for (int64_t r = 0; r < heads * queries; r++) {
        double low = INFINITY, high = -INFINITY;
        for (int64_t key = 0; key < keys; key++) {
            const float *a = q + r * dim, *b = k + (r / queries * keys + key) * dim;
            double logit = 0.0;
            for (int64_t c = 0; c < dim; c++) logit += (double)a[c] * (double)b[c];
            low = fmin(low, logit / sqrt((double)dim));
            high = fmax(high, logit / sqrt((double)dim));
        }
        spread = fmax(spread, high - low);
    }
    return spread;
}

// Largest error allowed. An offset that all logits share does not count, although torch's float32 run loses accuracy to
// it (8.862e-06).
static double numerics_attention_bar(int64_t keys, double spread) {
    if (keys == 1) return 0.0;
    if (spread == 0.0) return 2 * 7.390e-08;                  // the mean of the values
    // larger spreads: dominated by the float32 rounding of a logit
    return spread < 1000.0 ? 2 * 5.532e-07 : 2.9e-7 * spread;
}

static void check_numerics_attention(const test_tensors* file) {
    char name[64], what[128];
    for (size_t at = 0, cases = 0; numerics_next(file, "attn.", ".q", &at, name) || !CHECK(cases > 0); cases++) {
        test_tensor q_shape, k_shape, expected = numerics_get(file, "attn", name, "out_f64");
        float* q = numerics_floats(file, "attn", name, "q", &q_shape);
        float* k = numerics_floats(file, "attn", name, "k", &k_shape);
        float* v = numerics_floats(file, "attn", name, "v", NULL);
        const int64_t batch = (int64_t)q_shape.dim[0], heads = batch * (int64_t)q_shape.dim[1];
        const int64_t queries = (int64_t)q_shape.dim[2], keys = (int64_t)k_shape.dim[2], dim = (int64_t)q_shape.dim[3];
        snprintf(what, sizeof what, "attn.%s.mask", name);
        test_tensor mask = test_find_tensor(file, what);
        unsigned char* allowed = mask.v ? (unsigned char*)malloc(mask.count) : NULL;
        for (size_t i = 0; i < mask.count && allowed; i++) allowed[i] = mask.v[i] != 0.0;
        const double bar = numerics_attention_bar(keys, numerics_logit_spread(q, k, heads, queries, keys, dim));
        q = numerics_to_columns(q, heads, queries, dim);
        k = numerics_to_columns(k, heads, keys, dim);
        v = numerics_to_columns(v, heads, keys, dim);
        gsf__nn_attention_desc d;
        memset(&d, 0, sizeof d);
        d.queries = queries;
        d.keys = keys;
        d.heads = (int32_t)heads;
        d.head_dim = (int32_t)dim;
        d.q = q;
        d.k = k;
        d.v = v;
        d.mask = allowed;
        d.out = q;
        CHECK_OK(&numerics_ctx, gsf__nn_run_attention(&numerics_ctx, NULL, &d));
        float* out = (float*)malloc(expected.count * sizeof(float));
        for (int64_t r = 0; r < queries; r++)
            for (int64_t h = 0; h < heads; h++)
                memcpy(out + (h * queries + r) * dim, q + (r * heads + h) * dim, (size_t)dim * sizeof(float));
        snprintf(what, sizeof what, "attn.%s", name);
        test_compare_floats(what, out, expected.v, expected.count, bar);
        check_rel_l2(what, out, expected.v, expected.count, bar);
        free(q); free(k); free(v); free(out); free(allowed);
        test_free_tensor(&mask);
        test_free_tensor(&expected);
    }
}

// ---- norms ---------------------------------------------------------------------

static void numerics_compare(const char* group, const char* name, const float* out, const test_tensor* expected) {
    char what[128];
    snprintf(what, sizeof what, "%s.%s", group, name);
    const double largest = test_max_abs(expected->v, expected->count);
    test_compare_floats(what, out, expected->v, expected->count, 4e-7 * fmax(largest, 1.0));
    // the error of ln.huge, the reference's smallest
    check_rel_l2(what, out, expected->v, expected->count, 2 * 8.233e-08);
}

static void check_numerics_rows(const test_tensors* file, const char* group, int centre) {
    char name[64], prefix[16];
    test_tensor wide;
    float *weight = golden_floats(file, "ln.weight", &wide), *bias = golden_floats(file, "ln.bias", NULL);
    snprintf(prefix, sizeof prefix, "%s.", group);
    for (size_t at = 0, cases = 0; numerics_next(file, prefix, ".x", &at, name) || !CHECK(cases > 0); cases++) {
        test_tensor shape, expected = numerics_get(file, group, name, "out_f64");
        float* x = numerics_floats(file, group, name, "x", &shape);
        const int64_t rows = (int64_t)shape.dim[0], dim = (int64_t)shape.dim[1];
        const int plain = shape.dim[1] != wide.count; // there is no weight of this width
        if (centre) {
            test_tensor eps = numerics_get(file, group, name, "eps");
            gsf__nn_layer_norm(&numerics_ctx, x, rows, dim, plain ? NULL : weight, plain ? NULL : bias, (float)eps.v[0],
                               x);
            test_free_tensor(&eps);
        } else {
            gsf__nn_rms_norm(&numerics_ctx, x, rows, dim, plain ? NULL : weight, 1e-6f, x);
        }
        numerics_compare(group, name, x, &expected);
        free(x);
        test_free_tensor(&expected);
    }
    free(weight);
    free(bias);
}

static void check_numerics_groups(const test_tensors* file) {
    char name[64];
    for (size_t at = 0, cases = 0; numerics_next(file, "gn.", ".x", &at, name) || !CHECK(cases > 0); cases++) {
        test_tensor shape, expected = numerics_get(file, "gn", name, "out_f64");
        test_tensor groups = numerics_get(file, "gn", name, "groups");
        float* x = numerics_floats(file, "gn", name, "x", &shape);
        float* weight = numerics_floats(file, "gn", name, "weight", NULL);
        float* bias = numerics_floats(file, "gn", name, "bias", NULL);
        const size_t per = shape.count / shape.dim[0];
        for (size_t b = 0; b < shape.dim[0]; b++)
            gsf__nn_group_norm(&numerics_ctx, x + b * per, (int64_t)shape.dim[1], (int64_t)(per / shape.dim[1]),
                               (int64_t)groups.v[0], weight, bias, 1e-6f, x + b * per);
        numerics_compare("gn", name, x, &expected);
        free(x); free(weight); free(bias);
        test_free_tensor(&groups);
        test_free_tensor(&expected);
    }
}

// ---- activations and half floats -----------------------------------------------

static void check_numerics_activation(const test_tensors* file, gsf__nn_activation kind, const char* name, double bar) {
    char what[128];
    test_tensor shape;
    float* x = golden_floats(file, "act.x", &shape);
    float* y = (float*)malloc(shape.count * sizeof(float));
    snprintf(what, sizeof what, "act.%s_f64", name);
    test_tensor expected = test_get_tensor(file, what);
    gsf__nn_activate(&numerics_ctx, kind, x, (int64_t)shape.count, y);
    CHECK(expected.count == shape.count);
    for (size_t i = 0; i < shape.count; i++) {
        const double e = expected.v[i];
        snprintf(what, sizeof what, "%s(%g)", name, (double)x[i]);
        if (e != e) test_check(y[i] != y[i], what, __FILE__, __LINE__);
        else test_check_near((double)y[i], e, fmax(bar, 1.2e-7 * fabs(e)), what, __FILE__, __LINE__);
    }
    free(x);
    free(y);
    test_free_tensor(&expected);
}

static void check_numerics_halves(const test_tensors* file) {
    test_tensor f32 = test_get_tensor(file, "bf16.f32_bits"), b16 = test_get_tensor(file, "bf16.bf16_bits");
    test_tensor is_nan = test_get_tensor(file, "bf16.is_nan"), f16 = test_get_tensor(file, "f16.bits");
    test_tensor widened = test_get_tensor(file, "f16.f32");
    int wrong = 0;
    for (size_t i = 0; i < f32.count; i++) {
        const uint32_t bits = (uint32_t)(int32_t)f32.v[i];
        const uint16_t expected = (uint16_t)(int16_t)b16.v[i];
        float value;
        memcpy(&value, &bits, sizeof value);
        const uint16_t rounded = gsf__float_to_bf16(value);
        const float back = gsf__bf16_to_float(rounded);
        wrong += is_nan.v[i] != 0.0 ? back == back : rounded != expected;
    }
    CHECK(wrong == 0 && f32.count > 0);
    for (size_t i = 0; i < f16.count; i++) {
        const float value = gsf__half_to_float((uint16_t)(int16_t)f16.v[i]);
        if (widened.v[i] != widened.v[i]) CHECK(value != value);
        else CHECK((double)value == widened.v[i]);
    }
    CHECK(f16.count > 0);
    test_free_tensor(&f32); test_free_tensor(&b16); test_free_tensor(&is_nan); test_free_tensor(&f16);
    test_free_tensor(&widened);
}

static void check_numerics(void) {
    test_tensors file = test_open_tensors(test_golden("restorer/numerics/numerics.safetensors"));
    test_context_init(&numerics_ctx);
    check_numerics_attention(&file);
    check_numerics_rows(&file, "ln", 1);
    check_numerics_rows(&file, "rms", 0);
    check_numerics_groups(&file);
    check_numerics_activation(&file, GSF__NN_GELU_TANH, "gelu_tanh", 2 * 3.791e-07);
    check_numerics_activation(&file, GSF__NN_SILU, "silu", 2 * 9.483e-07);
    check_numerics_halves(&file);
    test_close_tensors(&file);
}
