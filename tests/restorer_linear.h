// restorer_linear.h - matrix products against restorer/numerics. Errors are relative to the sums of the products'
// magnitudes; the tolerance is 1e-6 (see the README about gemm_cancel).

// with the dtype that the file has
static gsf_nn_tensor linear_weight(const test_tensor* t, uint16_t** bits, float** floats) {
    gsf_nn_tensor w;
    memset(&w, 0, sizeof w);
    w.name = t->name;
    w.rank = 2;
    w.shape[0] = (int64_t)t->dim[0];
    w.shape[1] = (int64_t)t->dim[1];
    w.count = (int64_t)t->count;
    *floats = test_tensor_floats(t);
    *bits = (uint16_t*)malloc(t->count * sizeof(uint16_t));
    for (size_t i = 0; i < t->count; i++) (*bits)[i] = gsf__float_to_bf16((*floats)[i]);
    w.dtype = strcmp(t->dtype, "BF16") == 0 ? GSF_NN_BF16 : GSF_NN_F32;
    w.data = w.dtype == GSF_NN_BF16 ? (const void*)*bits : (const void*)*floats;
    return w;
}

static void check_linear_case(gsf_context* ctx, const test_tensors* file, const char* name, size_t copies) {
    char label[64];
    snprintf(label, sizeof label, "%s.a", name);
    test_tensor a = test_get_tensor(file, label);
    snprintf(label, sizeof label, "%s.b", name);
    test_tensor b = test_get_tensor(file, label);
    snprintf(label, sizeof label, "%s.out_f64", name);
    test_tensor expected = test_get_tensor(file, label);
    const size_t rows = a.dim[0], in = a.dim[1], out = b.dim[0];
    uint16_t* bits;
    float *floats, *once = test_tensor_floats(&a);
    const gsf_nn_tensor w = linear_weight(&b, &bits, &floats);
    // the same rows repeated, so that larger batches take other kernels
    float* x = (float*)malloc(copies * a.count * sizeof(float));
    float* y = (float*)malloc(copies * rows * out * sizeof(float));
    for (size_t i = 0; i < copies; i++) memcpy(x + i * a.count, once, a.count * sizeof(float));
    gsf__nn_linear_desc d;
    memset(&d, 0, sizeof d);
    d.x = x;
    d.rows = (int64_t)(copies * rows);
    d.weight = &w;
    d.y = y;
    CHECK_OK(ctx, gsf__nn_run_linear(ctx, NULL, &d));
    for (size_t i = 0; i < copies * rows; i++)
        for (size_t n = 0; n < out; n++) {
            double size = 0.0;
            for (size_t k = 0; k < in; k++) size += fabs(a.v[i % rows * in + k] * b.v[n * in + k]);
            CHECK_NEAR(y[i * out + n], expected.v[i % rows * out + n], 1e-6 * size);
        }
    free(x);
    free(y);
    free(once);
    free(bits);
    free(floats);
    test_free_tensor(&a);
    test_free_tensor(&b);
    test_free_tensor(&expected);
}

static void check_linear(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    test_tensors file = test_open_tensors(test_golden("restorer/numerics/numerics.safetensors"));
    static const char* const cases[] = {"gemm", "gemm_cancel", "gemm_bf16"};
    for (size_t i = 0; i < GSF__COUNT(cases); i++) {
        check_linear_case(&ctx, &file, cases[i], 1);
        check_linear_case(&ctx, &file, cases[i], 5);
        check_linear_case(&ctx, &file, cases[i], 200);
    }
    test_close_tensors(&file);
}
