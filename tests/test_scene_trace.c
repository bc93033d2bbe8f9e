// test_scene_trace.c - the ray tracer that examples/make_scene.c uses without Embree against a test of every triangle.
// gcc -O2 -std=c11 -I. -Itests -DGSFIXER_IMPLEMENTATION tests/test_scene_trace.c -lm
#undef GSF_USE_EMBREE
#include "gsfixer.h"

#include "test.h"
#include "../examples/scene_trace.h"

enum { TRIANGLES = 3000, RAYS = 4000 };

static float draw(uint64_t stream, uint64_t i, float lo, float hi) {
    return lo + (hi - lo) * (float)gsf_draw_uniform(1, stream, i);
}

// In double precision, without a tree. Returns the distance, infinite if the ray hits nothing.
static double nearest_of_all(const mesh_view* mesh, v3 from, v3 d) {
    const v3* points = (const v3*)mesh->at;
    double best = INFINITY;
    for (size_t i = 0; i < mesh->triangle_count; i++) {
        double e[2][3], q[3], n[3], m[3];
        const v3 a = points[mesh->corners[3 * i]];
        for (int k = 0; k < 2; k++) {
            const v3 b = points[mesh->corners[3 * i + 1 + (size_t)k]];
            e[k][0] = (double)b.x - (double)a.x, e[k][1] = (double)b.y - (double)a.y, e[k][2] = (double)b.z - (double)a.z;
        }
        q[0] = (double)from.x - (double)a.x, q[1] = (double)from.y - (double)a.y, q[2] = (double)from.z - (double)a.z;
        for (int k = 0; k < 3; k++) {
            const int x = (k + 1) % 3, y = (k + 2) % 3;
            n[k] = e[0][x] * e[1][y] - e[0][y] * e[1][x];
        }
        const double dir[3] = {(double)d.x, (double)d.y, (double)d.z};
        const double det = -(n[0] * dir[0] + n[1] * dir[1] + n[2] * dir[2]);
        if (fabs(det) < 1e-14) continue;
        for (int k = 0; k < 3; k++) {
            const int x = (k + 1) % 3, y = (k + 2) % 3;
            m[k] = q[x] * dir[y] - q[y] * dir[x];
        }
        const double t = (q[0] * n[0] + q[1] * n[1] + q[2] * n[2]) / det;
        const double u = (e[1][0] * m[0] + e[1][1] * m[1] + e[1][2] * m[2]) / det;
        const double w = -(e[0][0] * m[0] + e[0][1] * m[1] + e[0][2] * m[2]) / det;
        if (u >= 0 && w >= 0 && u + w <= 1 && t > 0 && t < best) best = t;
    }
    return best;
}

// Slivers and flat triangles of very different sizes, some of them in the same place.
static void make_triangles(v3* points, uint32_t* corners) {
    for (uint32_t i = 0; i < TRIANGLES; i++) {
        const float size = i % 7 == 0 ? 2.0f : i % 3 == 0 ? 0.02f : 0.2f;
        const uint64_t k = 9 * (uint64_t)(i % 50 == 0 ? 0 : i);
        const v3 at = v(draw(1, k, -3, 3), draw(1, k + 1, -3, 3), i % 5 == 0 ? 0.0f : draw(1, k + 2, -1, 1));
        for (uint32_t c = 0; c < 3; c++) {
            const uint64_t j = k + 3 * c;
            points[3 * i + c] = add(at, v(draw(2, j, -size, size), draw(2, j + 1, -size, size),
                                          i % 5 == 0 ? 0.0f : draw(2, j + 2, -size, size)));
            corners[3 * i + c] = 3 * i + c;
        }
    }
}

int main(void) {
    static v3 points[3 * TRIANGLES];
    static uint32_t corners[3 * TRIANGLES];
    const mesh_view mesh = {points, sizeof(v3), 3 * TRIANGLES, corners, TRIANGLES};
    tracer t;
    size_t hits = 0, misses = 0, edges = 0;
    memset(&t, 0, sizeof t);
    make_triangles(points, corners);
    CHECK(start_tracer(&t, &mesh) == NULL);
    for (uint64_t i = 0; i < RAYS; i++) {
        const v3 from = v(draw(3, 6 * i, -4, 4), draw(3, 6 * i + 1, -4, 4), draw(3, 6 * i + 2, -2, 2));
        v3 d = v(draw(3, 6 * i + 3, -1, 1), draw(3, 6 * i + 4, -1, 1), draw(3, 6 * i + 5, -1, 1));
        if (i % 10 == 0) d = v(0, 0, d.z < 0 ? -1.0f : 1.0f); // along an axis
        if (i % 10 == 1) d.z = 0.0f;
        d = unit(d);
        crossing got;
        const int found = find_nearest(&t, from, d, 0.0f, &got);
        const double truth = nearest_of_all(&mesh, from, d);
        if (found != (truth < INFINITY) || (found && fabs((double)got.t - truth) > 1e-4 * (1.0 + truth))) {
            edges++; // the ray passes within rounding of an edge
            continue;
        }
        hits += (size_t)found, misses += (size_t)!found;
        if (!found) CHECK(!is_crossed(&t, from, d, 0.0f, 100.0f));
        if (!found) continue;
        CHECK(got.triangle < TRIANGLES && got.u >= -1e-5f && got.v >= -1e-5f && got.u + got.v <= 1.00001f);
        const v3 a = points[3 * got.triangle], b = points[3 * got.triangle + 1], c = points[3 * got.triangle + 2];
        const v3 on = add(mul(a, 1.0f - got.u - got.v), add(mul(b, got.u), mul(c, got.v)));
        CHECK(sqrtf(dot(sub(on, add(from, mul(d, got.t))), sub(on, add(from, mul(d, got.t))))) < 1e-3f);
        CHECK(fabsf(dot(unit(got.face), unit(sub(b, a)))) < 1e-3f);
        CHECK(is_crossed(&t, from, d, 0.0f, got.t * 1.001f + 1e-4f));
        CHECK(!is_crossed(&t, from, d, 0.0f, got.t * 0.999f - 1e-4f));
    }
    printf("%zu hits, %zu misses, %zu at edges\n", hits, misses, edges);
    CHECK(hits > 1000 && misses > 100 && edges < 8);
    end_tracer(&t);
    return test_report();
}
