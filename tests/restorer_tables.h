// Position tables against those of diffusers: rotary 3e-6, sine-cosine 1e-12, time sinusoid 1e-4, all absolute. Also
// against the exact formula: within one float32 ulp of the value plus the error due to float32 angles, which the
// reference has and the library keeps on purpose.
#ifndef RESTORER_TABLES_H
#define RESTORER_TABLES_H

static inline double tables_ulp(double v) { // spacing of floats at v
    const float f = fabsf((float)v);
    return (double)(nextafterf(f, INFINITY) - f);
}

// Exact values: cos and sin of position * theta^(-2i/d). The angle may be off by (5 + 10 e) half ulps: from position,
// frequency, product, and the exponent e = 2i/d, whose rounding error is multiplied by ln(10000).
static void tables_check_rope_exact(const gsf__nn_rope_desc* d, const float* c, const float* s) {
    const double tall = (double)d->height / d->width > (double)d->base_height / d->base_width;
    const double rows = tall ? d->base_height : rint((double)d->base_width / d->width * d->height);
    const double columns = tall ? rint((double)d->base_height / d->height * d->width) : d->base_width;
    const double top = rint((d->base_height - rows) / 2), left = rint((d->base_width - columns) / 2);
    const int time = d->head_dim / 4, space = d->head_dim / 8 * 3;
    int bad = 0;
    for (int64_t row = 0; row < (int64_t)d->frames * d->height * d->width; row++) {
        const double h = (double)(row / d->width % d->height), w = (double)(row % d->width);
        const double bottom = (top + rows) * (d->height - 1) / d->height;
        const double right = (left + columns) * (d->width - 1) / d->width;
        const double p[3] = {(double)(row / d->width / d->height),
                             d->height > 1 ? top + h * (bottom - top) / (d->height - 1) : top,
                             d->width > 1 ? left + w * (right - left) / (d->width - 1) : left};
        for (int k = 0; k < d->head_dim; k++) {
            const int axis = k < time ? 0 : k < time + space ? 1 : 2, dim = axis == 0 ? time : space;
            const int at = k - (axis == 0 ? 0 : axis == 1 ? time : time + space);
            const double e = (double)(at / 2 * 2) / dim, angle = p[axis] * pow(10000.0, -e);
            const double slack = angle * (5 + 10 * e) / 16777216.0;
            const float cosine = c[row * d->head_dim + k], sine = s[row * d->head_dim + k];
            bad += fabs(cosine - cos(angle)) > tables_ulp(cosine) + slack;
            bad += fabs(sine - sin(angle)) > tables_ulp(sine) + slack;
        }
    }
    CHECK(bad == 0);
}

static void tables_check_rope(gsf_context* ctx, const test_tensors* file, int index, int pixels_per_token, int patch) {
    char name[64];
    snprintf(name, sizeof name, "rope%d.meta", index);
    // sample height and width (latent), height and width in pixels, frames
    test_tensor meta = test_get_tensor(file, name);
    snprintf(name, sizeof name, "rope%d.cos", index);
    test_tensor c = test_get_tensor(file, name);
    snprintf(name, sizeof name, "rope%d.sin", index);
    test_tensor s = test_get_tensor(file, name);
    gsf__nn_rope_desc d;
    memset(&d, 0, sizeof d);
    d.base_height = (int32_t)meta.v[0] / patch;
    d.base_width = (int32_t)meta.v[1] / patch;
    d.height = (int32_t)meta.v[2] / pixels_per_token;
    d.width = (int32_t)meta.v[3] / pixels_per_token;
    d.frames = (int32_t)meta.v[4];
    d.head_dim = (int32_t)c.dim[1];
    const size_t stride = (size_t)meta.v[5], rows = (size_t)d.frames * (size_t)d.height * (size_t)d.width;
    CHECK(c.dim[0] == (rows + stride - 1) / stride && s.dim[0] == c.dim[0]); // every stride-th row
    float* cosine = (float*)malloc(rows * c.dim[1] * sizeof(float));
    float* sine = (float*)malloc(rows * c.dim[1] * sizeof(float));
    if (CHECK_OK(ctx, gsf__nn_make_rope(ctx, &d, cosine, sine))) {
        for (size_t r = 0; r < c.dim[0] && r * stride < rows; r++) {
            test_compare_floats(c.name, cosine + r * stride * c.dim[1], c.v + r * c.dim[1], c.dim[1], 3e-6);
            test_compare_floats(s.name, sine + r * stride * c.dim[1], s.v + r * c.dim[1], c.dim[1], 3e-6);
        }
        tables_check_rope_exact(&d, cosine, sine);
    }
    free(cosine);
    free(sine);
    test_free_tensor(&meta);
    test_free_tensor(&c);
    test_free_tensor(&s);
}

// The file does not say how h*w splits into height and width: one of the splits must match.
static void tables_check_sincos(gsf_context* ctx, const test_tensors* file, const char* name, double spatial,
                                double temporal) {
    test_tensor t = test_get_tensor(file, name);
    double* wide = (double*)malloc(t.count * sizeof(double));
    float* narrow = (float*)malloc(t.count * sizeof(float));
    double best = INFINITY;
    for (size_t h = 1; h <= t.dim[1]; h++) {
        if (t.dim[1] % h != 0) continue;
        const gsf__nn_axes axes = {(int32_t)t.dim[0], (int32_t)h, (int32_t)(t.dim[1] / h), (int32_t)t.dim[2], 1};
        double error = 0.0;
        if (!CHECK_OK(ctx, gsf__nn_sincos(ctx, &axes, spatial, temporal, wide, NULL))) continue;
        for (size_t i = 0; i < t.count; i++) error = fmax(error, fabs(wide[i] - t.v[i]));
        if (error >= best) continue;
        best = error;
        CHECK_OK(ctx,
                 gsf__nn_make_sincos(ctx, axes.frames, axes.height, axes.width, axes.dim, spatial, temporal, narrow));
        int bad = 0;
        for (size_t i = 0; i < t.count; i++) bad += fabs(narrow[i] - wide[i]) > tables_ulp(wide[i]);
        CHECK(bad == 0);
    }
    CHECK_NEAR(best, 0.0, 1e-12);
    free(wide);
    free(narrow);
    test_free_tensor(&t);
}

// Rows are for a subset of `times`, in the same order. Exact values: the angle may be off by (3 + 2 e) half ulps, where
// e is the exponent.
static void tables_check_timesteps(const test_tensors* file, const char* name, const test_tensor* times) {
    test_tensor t = test_get_tensor(file, name);
    const int dim = (int)t.dim[1];
    float* out = (float*)malloc((size_t)dim * sizeof(float));
    size_t next = 0;
    for (size_t row = 0; row < t.dim[0]; row++) {
        double error = INFINITY;
        for (; next < times->count && error > 1e-4; next++) {
            gsf__nn_embed_timestep(times->v[next], dim, out);
            error = 0.0;
            for (int k = 0; k < dim; k++) error = fmax(error, fabs(out[k] - t.v[row * t.dim[1] + (size_t)k]));
        }
        CHECK_NEAR(error, 0.0, 1e-4);
    }
    for (size_t k = 0; k < times->count; k++) {
        int bad = 0;
        gsf__nn_embed_timestep(times->v[k], dim, out);
        for (int i = 0; i < dim / 2; i++) {
            const double e = log(10000.0) * i / (dim / 2), angle = times->v[k] * exp(-e);
            const double slack = angle * (3 + 2 * e) / 16777216.0;
            bad += fabs(out[i] - cos(angle)) > tables_ulp(out[i]) + slack;
            bad += fabs(out[dim / 2 + i] - sin(angle)) > tables_ulp(out[dim / 2 + i]) + slack;
        }
        CHECK(bad == 0);
    }
    free(out);
    test_free_tensor(&t);
}

static void check_tables(void) {
    gsf_context ctx;
    gsf__nn_config config, vae;
    gsf_nn_weights names;
    int64_t patch = 2, blocks[16];
    size_t levels = 4;
    double spatial = 1.875, temporal = 1.0;
    test_context_init(&ctx);
    if (CHECK_OK(&ctx, gsf__nn_open_config(&ctx, test_golden("restorer/model/transformer"), "config.json", 0, &config))) {
        CHECK_OK(&ctx, gsf__nn_config_int(&config, "patch_size", 1, 64, &patch));
        CHECK_OK(&ctx, gsf__nn_config_number(&config, "spatial_interpolation_scale", 0.01, 100.0, &spatial));
        CHECK_OK(&ctx, gsf__nn_config_number(&config, "temporal_interpolation_scale", 0.01, 100.0, &temporal));
    }
    gsf__nn_close_config(&config);
    if (CHECK_OK(&ctx, gsf__nn_open_config(&ctx, test_golden("restorer/model/vae"), "config.json", 0, &vae)))
        CHECK_OK(&ctx, gsf__nn_config_ints(&vae, "block_out_channels", 1, 65536, 16, blocks, &levels));
    gsf__nn_close_config(&vae);

    const char* path = test_golden("restorer/transformer/tables.safetensors");
    if (!CHECK_OK(&ctx, gsf_nn_load_weights(&ctx, path, NULL, &names))) return;
    test_tensors file = test_open_tensors(path);
    test_tensor times = test_get_tensor(&file, "timestep_emb.t");
    int ropes = 0, sincos = 0, embeddings = 0;
    for (size_t i = 0; i < names.tensor_count; i++) {
        const char* name = names.tensors[i].name;
        int index;
        if (sscanf(name, "rope%d.", &index) == 1 && strstr(name, ".meta"))
            tables_check_rope(&ctx, &file, index, (int)patch << (levels - 1), (int)patch), ropes++;
        if (strncmp(name, "sincos3d.", 9) == 0) tables_check_sincos(&ctx, &file, name, spatial, temporal), sincos++;
        if (strncmp(name, "timestep_emb.dim", 16) == 0) tables_check_timesteps(&file, name, &times), embeddings++;
    }
    CHECK(ropes > 0 && sincos > 0 && embeddings > 0);
    test_free_tensor(&times);
    test_close_tensors(&file);
    gsf_nn_destroy_weights(&ctx, &names);
}

#endif
