// The vector vocabulary of gsfixer.h (>>lanes) at each instruction set of the machine: every operation on every lane
// against scalar C, special values included; tails in exact-size buffers; sums in the documented order; powers.
// The checks are themselves kernels: this file includes itself once per instruction set, as the headers do.
#ifndef GSF__ISA

#define GSFIXER_BASE_IMPLEMENTATION
#include "gsfixer.h"

#include "test.h"

enum { MOST = 16 }; // lanes

static uint64_t seed = 7;

static int same(float a, float b) { return memcmp(&a, &b, sizeof a) == 0 || (a != a && b != b); }

static float interesting(size_t i) {
    static const float special[] = {0.0f, -0.0f, 1.0f, -1.0f, 0.5f, 1.5f, -2.5f, INFINITY, -INFINITY, NAN, 1e-40f, 3e38f};
    const size_t count = GSF__COUNT(special);
    return i % 3 == 0 ? special[i / 3 % count] : (float)test_random_in(&seed, -100.0, 100.0);
}

#define GSF__KERNELS "tests/test_lanes.c" // as gsfixer.h sees it
#define GSF__KERNELS_CHECKS
#define GSF__KERNELS_AVX512
#define GSF__KERNELS_SIMD128
#include "gsfixer.h"
#undef GSF__KERNELS_CHECKS

int main(void) {
    gsf_context ctx;
    test_context_init(&ctx);
    check_lanes_scalar();
#if GSF__X86
    if (ctx.cpu_level >= GSF_CPU_AVX2) check_lanes_avx2();
    if (ctx.cpu_level >= GSF_CPU_AVX512) check_lanes_avx512();
#elif GSF__SIMD128
    if (ctx.cpu_level == GSF_CPU_SIMD128) check_lanes_simd128();
#endif
    return test_report();
}

#endif // GSF__ISA

#ifdef GSF__KERNELS_CHECKS

#define ARRAY(v) (gsf__v_store(out, (v)), (const float*)out)
#define INTS(v) (gsf__vi_store(ints, (v)), (const int32_t*)ints)

GSF__V_KERNEL void GSF__V(check_pairs)(const float* x, const float* y, const float* z) {
    float out[MOST];
    const gsf__vf a = gsf__v_load(x), b = gsf__v_load(y), c = gsf__v_load(z);
    const gsf__vf results[12] = {a + b, a - b, a * b, a / b, gsf__v_min(a, b), gsf__v_max(a, b), gsf__v_sqrt(a), gsf__v_abs(a),
                                 gsf__v_with_sign(a, b), gsf__v_round(a), gsf__v_floor(a), gsf__v_ceil(a)};
    for (int op = 0; op < 12; op++) {
        (void)ARRAY(results[op]);
        for (int i = 0; i < GSF__LANES; i++) {
            const float p = x[i], q = y[i];
            const float expected[12] = {p + q, p - q, p * q, p / q, p < q ? p : q, p > q ? p : q, sqrtf(p), fabsf(p),
                                        signbit(q) ? -p : p, rintf(p), floorf(p), ceilf(p)};
            if (!CHECK(same(out[i], expected[op]))) fprintf(stderr, "operation %d of %g %g: %g\n", op, p, q, out[i]);
        }
    }
    for (int op = 0; op < 3; op++) {
        (void)ARRAY(op == 0 ? gsf__v_madd(a, b, c) : op == 1 ? gsf__v_msub(a, b, c) : gsf__v_nmadd(a, b, c));
        for (int i = 0; i < GSF__LANES; i++) {
            const double p = op == 2 ? -(double)x[i] : (double)x[i], r = op == 1 ? -(double)z[i] : (double)z[i];
            const double exact = p * (double)y[i] + r, size = fabs(p * (double)y[i]) + fabs(r); // exact products
            if (isfinite(exact) && size < 3e38)
                CHECK(fabs((double)out[i] - exact) <= 1.2e-7 * (GSF__FUSED ? fabs(exact) : size) + 1e-45);
            else if (isnan(exact))
                CHECK(out[i] != out[i]);
        }
    }
    const gsf__vm masks[5] = {gsf__v_eq(a, b), gsf__v_lt(a, b), gsf__v_le(a, b), gsf__v_gt(a, b), gsf__v_ge(a, b)};
    for (int op = 0; op < 5; op++) {
        const gsf__vm m = masks[op];
        float kept[MOST], chosen[MOST], neither[MOST];
        gsf__v_store(kept, gsf__v_keep(m, c));
        gsf__v_store(chosen, gsf__v_select(m, a, c));
        gsf__v_store(neither, gsf__v_keep(gsf__vm_not(m), c));
        const uint32_t bits = gsf__vm_bits(m);
        CHECK(bits >> GSF__LANES == 0);
        CHECK(gsf__vm_bits(gsf__vm_of_bits(bits)) == bits);
        CHECK(gsf__vm_bits(gsf__vm_and(m, gsf__vm_not(m))) == 0);
        CHECK(gsf__vm_bits(gsf__vm_or(m, gsf__vm_not(m))) == gsf__vm_bits(gsf__vm_first(GSF__LANES)));
        for (int i = 0; i < GSF__LANES; i++) {
            const int holds[5] = {x[i] == y[i], x[i] < y[i], x[i] <= y[i], x[i] > y[i], x[i] >= y[i]};
            CHECK((int)(bits >> i & 1u) == holds[op]);
            CHECK(same(kept[i], holds[op] ? z[i] : 0.0f) && same(neither[i], holds[op] ? 0.0f : z[i]));
            CHECK(same(chosen[i], holds[op] ? x[i] : z[i]));
        }
    }
}

GSF__V_KERNEL void GSF__V(check_integers)(void) {
    float out[MOST];
    int32_t ints[MOST], a[MOST], b[MOST];
    for (int i = 0; i < MOST; i++) {
        a[i] = (int32_t)(uint32_t)gsf_draw_bits(1, 2, (uint64_t)i);
        b[i] = (int32_t)(uint32_t)gsf_draw_bits(1, 3, (uint64_t)i);
    }
    const gsf__vi p = gsf__vi_load(a), q = gsf__vi_load(b);
    const gsf__vm odd = gsf__vm_of_bits(0xaaaau & ((1u << GSF__LANES) - 1u));
    for (int i = 0; i < GSF__LANES; i++) {
        const uint32_t u = (uint32_t)a[i], v = (uint32_t)b[i];
        CHECK(INTS(gsf__vi_add(p, q))[i] == (int32_t)(u + v) && INTS(gsf__vi_sub(p, q))[i] == (int32_t)(u - v));
        CHECK(INTS(gsf__vi_mul(p, q))[i] == (int32_t)(u * v) && INTS(gsf__vi_min(p, q))[i] == (a[i] < b[i] ? a[i] : b[i]));
        CHECK(INTS(gsf__vi_shl(p, 23))[i] == (int32_t)(u << 23) && INTS(gsf__vi_sar(p, 7))[i] == a[i] >> 7);
        CHECK(INTS(gsf__vi_keep(odd, p))[i] == (i % 2 ? a[i] : 0));
        int32_t pairs[2 * MOST];
        gsf__vi_store_pairs(pairs, p, q);
        CHECK(pairs[2 * i] == a[i] && pairs[2 * i + 1] == b[i]);
        CHECK(INTS(gsf__vi_index())[i] == i && INTS(gsf__vi_set(-5))[i] == -5);
        CHECK(ARRAY(gsf__vi_floats(p))[i] == (float)a[i]);
        CHECK(INTS(gsf__v_bits(gsf__vi_as_floats(p)))[i] == a[i]);
    }
    float x[MOST], table[64];
    for (int i = 0; i < MOST; i++) x[i] = 0.5f * (float)(i - 7) + (i % 4 == 1 ? 0.01f : 0.0f);
    for (int i = 0; i < 64; i++) table[i] = (float)(i * i);
    for (int i = 0; i < MOST; i++) a[i] = (i * 29 + 5) % 64;
    for (int i = 0; i < GSF__LANES; i++) {
        CHECK(INTS(gsf__v_to_int(gsf__v_load(x)))[i] == (int32_t)rintf(x[i]));
        CHECK(INTS(gsf__v_truncate(gsf__v_load(x)))[i] == (int32_t)x[i]);
        CHECK(ARRAY(gsf__v_gather(table, gsf__vi_load(a)))[i] == table[a[i]]);
    }
}

GSF__V_KERNEL void GSF__V(check_tails)(void) {
    float out[MOST];
    for (size_t n = 0; n <= GSF__LANES + 1; n++) { // buffers of exactly that size, for the address sanitizer
        const size_t used = n < GSF__LANES ? n : GSF__LANES;
        float* from = (float*)malloc(n * sizeof(float) + (n == 0));
        float* to = (float*)malloc(n * sizeof(float) + (n == 0));
        uint8_t* bytes = (uint8_t*)malloc(n + (n == 0));
        for (size_t i = 0; i < n; i++) {
            from[i] = (float)i + 0.25f;
            to[i] = -1.0f;
            bytes[i] = (uint8_t)(255 - 13 * i);
        }
        (void)ARRAY(gsf__v_load_first(from, n));
        for (size_t i = 0; i < GSF__LANES; i++) CHECK(out[i] == (i < used ? from[i] : 0.0f));
        gsf__v_store_first(to, gsf__v_set(3.0f), n);
        for (size_t i = 0; i < n; i++) CHECK(to[i] == (i < used ? 3.0f : -1.0f));
        (void)ARRAY(gsf__v_load_bytes(bytes, n));
        for (size_t i = 0; i < GSF__LANES; i++) CHECK(out[i] == (i < used ? (float)bytes[i] : 0.0f));
        CHECK(gsf__vm_bits(gsf__vm_first(n)) == (uint32_t)((1u << used) - 1u));
        free(from);
        free(to);
        free(bytes);
    }
}

GSF__V_KERNEL void GSF__V(check_across)(void) {
    float x[MOST], sums[MOST], out[MOST];
    float most = -INFINITY;
    for (int i = 0; i < MOST; i++) sums[i] = x[i] = (float)test_random_in(&seed, -1e4, 1e4);
    const gsf__vf v = gsf__v_load(x);
    for (int i = 0; i < GSF__LANES; i++) most = fmaxf(most, x[i]);
    CHECK(gsf__v_largest(v) == most);
    for (int n = GSF__LANES / 2; n > 0; n /= 2)
        for (int i = 0; i < n; i++) sums[i] += sums[i + n];
    CHECK(gsf__v_sum(v) == sums[0]);

    gsf__vf m[GSF__LANES];
    for (int i = 0; i < GSF__LANES; i++) m[i] = gsf__v_set((float)(100 * i)) + gsf__vi_floats(gsf__vi_index());
    gsf__v_transpose(m);
    for (int i = 0; i < GSF__LANES; i++)
        for (int k = 0; k < GSF__LANES; k++) CHECK(ARRAY(m[i])[k] == (float)(100 * k + i));

    gsf__vd halves[GSF__HALVES], roots[GSF__HALVES], sum = gsf__vd_set(0.0), folded = gsf__vd_set(0.0);
    for (int h = 0; h < GSF__HALVES; h++) {
        halves[h] = gsf__vd_load(x + h * (GSF__LANES / GSF__HALVES));
        CHECK(gsf__vd_sum(halves[h] - gsf__vd_half(v, h)) == 0.0);
        sum = sum + halves[h];
        roots[h] = gsf__vd_keep_above(halves[h], gsf__vd_set(0.0), gsf__vd_sqrt(gsf__vd_max(gsf__vd_set(4.0), halves[h])));
        halves[h] = gsf__vd_madd(halves[h], gsf__vd_set(2.0), gsf__vd_set(1e-9));
    }
    double expected = 0.0;
    for (int i = 0; i < GSF__LANES; i++) {
        const double root = x[i] > 0.0f ? sqrt(fmax((double)x[i], 4.0)) : 0.0;
        CHECK(ARRAY(gsf__vd_floats(halves))[i] == (float)((double)x[i] * 2.0 + 1e-9));
        CHECK(ARRAY(gsf__vd_floats(roots))[i] == (float)root);
        expected += (double)x[i];
    }
    CHECK_NEAR(gsf__vd_sum(sum), expected, 1e-9);
    double doubles[MOST], copies[MOST];
    for (int i = 0; i < MOST; i++) doubles[i] = 1.0 / (double)(i + 3);
    for (int h = 0; h < GSF__HALVES; h++) {
        const int at = h * (GSF__LANES / GSF__HALVES);
        gsf__vd_write(copies + at, gsf__vd_read(doubles + at));
    }
    CHECK(memcmp(copies, doubles, GSF__LANES * sizeof(double)) == 0);
    folded = gsf__vd_add_folded(folded, v);
    CHECK_NEAR(gsf__vd_sum(folded), expected, GSF__LANES * 1e-3);
    gsf__vf pinned = v;
    gsf__v_pin(&pinned);
    gsf__v_fetch(x);
    for (int i = 0; i < GSF__LANES; i++) CHECK(ARRAY(pinned)[i] == x[i]);
}

GSF__V_KERNEL void GSF__V(check_powers)(void) {
    float x[MOST], two[MOST], e[MOST];
    double worst_two = 0.0, worst_e = 0.0;
    for (double from = -140.0; from < 135.0; from += 0.0007 * GSF__LANES) {
        for (int i = 0; i < GSF__LANES; i++) x[i] = (float)(from + 0.0007 * i);
        gsf__v_store(two, gsf__v_exp2(gsf__v_load(x)));
        gsf__v_store(e, gsf__v_exp(gsf__v_load(x)));
        for (int i = 0; i < GSF__LANES; i++) {
            const double exact_two = exp2((double)x[i]), exact_e = exp((double)x[i]);
            if (exact_two >= 1.7e-38 && exact_two <= FLT_MAX)
                worst_two = fmax(worst_two, fabs((double)two[i] - exact_two) / exact_two);
            if (exact_e >= 1.7e-38 && exact_e <= (double)FLT_MAX * (1.0 - 2e-7))
                worst_e = fmax(worst_e, fabs((double)e[i] - exact_e) / exact_e);
            if (exact_two < 1.7e-38) CHECK(two[i] >= 0.0f && two[i] <= 1.7e-38f);
            if (exact_e > (double)FLT_MAX * (1.0 + 3e-8)) CHECK(e[i] == INFINITY);
        }
    }
    CHECK_NEAR(worst_two, 0.0, 2e-7);
    CHECK_NEAR(worst_e, 0.0, 2e-7);
    const float special[5] = {0.0f, -0.0f, INFINITY, -INFINITY, NAN}, expected[5] = {1.0f, 1.0f, INFINITY, 0.0f, NAN};
    for (int k = 0; k < 5; k++) {
        gsf__v_store(two, gsf__v_exp2(gsf__v_set(special[k])));
        gsf__v_store(e, gsf__v_exp(gsf__v_set(special[k])));
        for (int i = 0; i < GSF__LANES; i++) CHECK(same(two[i], expected[k]) && same(e[i], expected[k]));
    }
}

static void GSF__V(check_lanes)(void) {
    float x[MOST], y[MOST], z[MOST];
    for (int run = 0; run < 200; run++) {
        for (size_t i = 0; i < MOST; i++) {
            x[i] = interesting((size_t)run + i);
            y[i] = interesting((size_t)run * 5 + 7 * i + 1);
            z[i] = interesting((size_t)run * 11 + i + 2);
        }
        GSF__V(check_pairs)(x, y, z);
    }
    GSF__V(check_integers)();
    GSF__V(check_tails)();
    GSF__V(check_across)();
    GSF__V(check_powers)();
}

#undef ARRAY
#undef INTS

#endif // GSF__KERNELS_CHECKS
