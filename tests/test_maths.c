// The elementary functions of >>maths against the C library's, which is right to an ulp or two.
#define GSFIXER_IMPLEMENTATION
#include "gsfixer_splat.h"

#include "test.h"

static double ulp_of(double x) { return x == 0.0 ? 0x1p-1074 : ldexp(1.0, ilogb(x) - 52 > -1074 ? ilogb(x) - 52 : -1074); }

static double worst_ulps; // of the function that is being checked

static void meet(double ours, double theirs) {
    if (ours == theirs || (ours != ours && theirs != theirs)) return;
    const double ulps = fabs(ours - theirs) / ulp_of(theirs);
    if (!(ulps <= worst_ulps)) worst_ulps = ulps;
}

static void check(const char* name, double most) {
    if (!CHECK(worst_ulps <= most)) fprintf(stderr, "%s: %g ulp\n", name, worst_ulps);
    worst_ulps = 0.0;
}

static void check_floats(void) {
    uint64_t random = 2;
    int wrong = 0; // results that differ from the C library's, which rounds correctly nearly always
    for (int i = 0; i < 200000; i++) {
        const float x = (float)test_random_in(&random, -104.0, 89.0), y = (float)exp(test_random_in(&random, -87.0, 88.0));
        wrong += gsf__exp_f32(x) != expf(x);
        wrong += gsf__exp2_f32(1.4f * x) != exp2f(1.4f * x);
        wrong += gsf__log_f32(y) != logf(y);
    }
    CHECK(wrong < 600);
    CHECK(gsf__exp2_f32(-149.0f) == 0x1p-149f && gsf__exp2_f32(127.5f) > 2e38f && gsf__exp2_f32(128.0f) == INFINITY);
    CHECK(gsf__exp2_f32(-1000.0f) == 0.0f && gsf__exp2_f32(NAN) != gsf__exp2_f32(NAN) && gsf__exp2_f32(0.0f) == 1.0f);
}

static void check_exponentials(void) {
    uint64_t random = 1;
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -745.0, 709.7), y = test_random_in(&random, -2.0, 2.0);
        meet(gsf__exp_f64(x), exp(x));
        meet(gsf__exp_f64(y), exp(y));
    }
    check("exp", 1.5);
    for (int i = 0; i < 200000; i++) {
        const double x = exp(test_random_in(&random, -740.0, 709.0)), y = test_random_in(&random, 0.5, 2.0);
        meet(gsf__log_f64(x), log(x));
        meet(gsf__log_f64(y), log(y));
    }
    check("log", 1.5);
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -0.999, 5.0), y = x * exp(-60.0 * test_random(&random));
        meet(gsf__log1p_f64(x), log1p(x));
        meet(gsf__log1p_f64(y), log1p(y));
    }
    check("log1p", 2.5);
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -40.0, 700.0), y = test_random_in(&random, -1.0, 1.0);
        meet(gsf__expm1_f64(x), expm1(x));
        meet(gsf__expm1_f64(y), expm1(y));
    }
    check("expm1", 4.5);
    const double inf = (double)INFINITY;
    CHECK(gsf__exp_f64(0.0) == 1.0 && gsf__exp_f64(-inf) == 0.0 && gsf__exp_f64(inf) == inf && gsf__exp_f64(710.0) == inf);
    CHECK(gsf__log_f64(1.0) == 0.0 && gsf__log_f64(0.0) == -inf && gsf__log_f64(inf) == inf);
    CHECK(gsf__log_f64(-1.0) != gsf__log_f64(-1.0) && gsf__exp_f64((double)NAN) != gsf__exp_f64((double)NAN));
    CHECK(gsf__power_f64(0.9, 0) == 1.0 && gsf__power_f64(0.9, 1) == 0.9 && gsf__power_f64(3.0, 20) == 3486784401.0);
    CHECK(fabs(gsf__power_f64(0.999, 3000) / pow(0.999, 3000.0) - 1.0) < 3000 * 2.3e-16);
}

static void check_angles(void) {
    uint64_t random = 3;
#ifdef _WIN32 // where sin and cos are the processor's, which has too few digits of pi; same_bits.sh compares with Linux
    const double reach = 1.5;
#else
    const double reach = 1e5;
#endif
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -1.5, 1.5), y = test_random_in(&random, -reach, reach);
        meet(gsf__sin_f64(x), sin(x));
        meet(gsf__cos_f64(x), cos(x));
        meet(gsf__sin_f64(y), sin(y));
        meet(gsf__cos_f64(y), cos(y));
    }
    check("sin, cos", 1.5);
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -1.5, 1.5);
        meet(gsf__tan_f64(x), tan(x));
    }
    check("tan", 3.0);
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -1.0, 1.0), y = test_random_in(&random, -1.0, 1.0);
        meet(gsf__atan2_f64(y, x), atan2(y, x));
        meet(gsf__atan2_f64(y * y * y, x), atan2(y * y * y, x));
    }
    check("atan2", 3.0);
    for (int i = 0; i < 200000; i++) {
        const double x = test_random_in(&random, -1.0, 1.0);
        meet(gsf__acos_f64(x), acos(x));
    }
    check("acos", 4.0);
    for (int i = 0; i < 200000; i++) {
        const double x = exp(test_random_in(&random, -700.0, 700.0));
        meet(gsf__cbrt_f64(i & 1 ? x : -x), cbrt(i & 1 ? x : -x));
    }
    check("cbrt", 3.0);
    CHECK(gsf__sin_f64(0.0) == 0.0 && gsf__cos_f64(0.0) == 1.0 && gsf__acos_f64(1.0) == 0.0 && gsf__atan2_f64(0.0, 0.0) == 0.0);
    CHECK(gsf__acos_f64(-1.0) == 3.14159265358979311600 && gsf__cbrt_f64(27.0) == 3.0 && gsf__cbrt_f64(0.0) == 0.0);
}

int main(void) {
    check_floats();
    check_exponentials();
    check_angles();
    return test_report();
}
