// scene_trace.h - nearest hits and shadows in a mesh of triangles: by Embree if GSF_USE_EMBREE is defined, else by a
// bounding volume hierarchy of its own. Both find the same surfaces; hit distances may differ in the last bit. Part of
// make_scene.c. SPDX-License-Identifier: MIT
#ifndef SCENE_TRACE_H
#define SCENE_TRACE_H

#include "scene_math.h"

typedef struct crossing {
    float t, u, v;     // distance; barycentric coordinates of the 2nd and 3rd vertex
    v3 face;           // normal of the triangle, of any length and sign
    uint32_t triangle; // index
} crossing;

// Vertices are given by their positions, `stride` bytes apart, triangles by three indices each. Both are borrowed.
typedef struct mesh_view {
    const void* at;
    size_t stride, vertex_count;
    const uint32_t* corners;
    size_t triangle_count;
} mesh_view;

#ifdef GSF_USE_EMBREE

#if defined(__has_include)
#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif
#else
#include <embree3/rtcore.h>
#endif

typedef struct tracer { RTCDevice device; RTCScene scene; } tracer;

// Returns NULL or what went wrong. end_tracer in either case.
static const char* start_tracer(tracer* out, const mesh_view* mesh) {
    out->device = rtcNewDevice("threads=1,set_affinity=0");
    if (!out->device) return "Embree cannot create a device";
    RTCGeometry geometry = rtcNewGeometry(out->device, RTC_GEOMETRY_TYPE_TRIANGLE);
    out->scene = rtcNewScene(out->device);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, mesh->at, 0, mesh->stride,
                               mesh->vertex_count);
    rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, mesh->corners, 0,
                               3 * sizeof *mesh->corners, mesh->triangle_count);
    rtcCommitGeometry(geometry);
    rtcAttachGeometry(out->scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(out->scene);
    if (rtcGetDeviceError(out->device) == RTC_ERROR_NONE) return NULL;
    out->scene = NULL; // leaked on purpose: releasing it could wait for a TBB task that never ran
    return "Embree cannot build the scene";
}

static void end_tracer(tracer* t) {
    if (t->scene) rtcReleaseScene(t->scene);
    if (t->device) rtcReleaseDevice(t->device);
}

static struct RTCRay make_ray(v3 from, v3 d, float least, float most) {
    struct RTCRay ray;
    memset(&ray, 0, sizeof ray);
    ray.org_x = from.x, ray.org_y = from.y, ray.org_z = from.z;
    ray.dir_x = d.x, ray.dir_y = d.y, ray.dir_z = d.z;
    ray.tnear = least, ray.tfar = most;
    ray.mask = 0xffffffffu;
    return ray;
}

static int is_crossed(const tracer* t, v3 from, v3 d, float least, float most) {
    struct RTCRay ray = make_ray(from, d, least, most);
#if RTC_VERSION_MAJOR < 4
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcOccluded1(t->scene, &context, &ray);
#else
    rtcOccluded1(t->scene, &ray, NULL);
#endif
    return ray.tfar < 0.0f;
}

static int find_nearest(const tracer* t, v3 from, v3 d, float least, crossing* out) {
    struct RTCRayHit r;
    memset(&r, 0, sizeof r);
    r.ray = make_ray(from, d, least, INFINITY);
    r.hit.geomID = RTC_INVALID_GEOMETRY_ID;
#if RTC_VERSION_MAJOR < 4
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    rtcIntersect1(t->scene, &context, &r);
#else
    rtcIntersect1(t->scene, &r, NULL);
#endif
    if (r.hit.geomID == RTC_INVALID_GEOMETRY_ID) return 0;
    out->t = r.ray.tfar, out->u = r.hit.u, out->v = r.hit.v;
    out->face = v(r.hit.Ng_x, r.hit.Ng_y, r.hit.Ng_z);
    out->triangle = r.hit.primID;
    return 1;
}

#else

// Inner nodes have their children at `first` and `first` + 1; leaves, with a count above 0, have triangles from `first`
// on.
typedef struct bvh_node { v3 lo; uint32_t first; v3 hi; uint32_t count; } bvh_node;
typedef struct bvh_triangle { v3 at, edge_u, edge_v; uint32_t index; } bvh_triangle;
typedef struct tracer { bvh_node* nodes; bvh_triangle* triangles; } tracer;

enum {
    BVH_BINS = 12,
    BVH_LEAF = 4,
    BVH_SPLITS = 48, // deeper nodes are halved by count
    BVH_STACK = 96   // BVH_SPLITS and another 32 levels
};

typedef struct bvh_item { v3 lo, hi, center; uint32_t index; } bvh_item;

static float axis_of(v3 a, int axis) { return axis == 0 ? a.x : axis == 1 ? a.y : a.z; }
static v3 lowest(v3 a, v3 b) { return v(minf(a.x, b.x), minf(a.y, b.y), minf(a.z, b.z)); }
static v3 highest(v3 a, v3 b) { return v(maxf(a.x, b.x), maxf(a.y, b.y), maxf(a.z, b.z)); }
static float half_area(v3 lo, v3 hi) {
    const v3 d = sub(hi, lo);
    return d.x * d.y + d.y * d.z + d.z * d.x;
}

static int bin_of(const bvh_item* item, int axis, float lo, float scale) {
    const int bin = (int)((axis_of(item->center, axis) - lo) * scale);
    return bin < 0 ? 0 : bin >= BVH_BINS ? BVH_BINS - 1 : bin;
}

// Best of the planes between bins by the surface area heuristic. Returns its cost, infinite if there is none.
static float find_split(const bvh_item* items, size_t count, int axis, float lo, float hi, int* split) {
    typedef struct bin { v3 lo, hi; size_t count; } bin;
    bin bins[BVH_BINS];
    float right[BVH_BINS], best = INFINITY;
    if (!(hi - lo > 1e-9f)) return best;
    const float scale = (float)BVH_BINS / (hi - lo);
    const bin none = {{1e30f, 1e30f, 1e30f}, {-1e30f, -1e30f, -1e30f}, 0};
    for (int i = 0; i < BVH_BINS; i++) bins[i] = none;
    for (size_t i = 0; i < count; i++) {
        bin* b = bins + bin_of(items + i, axis, lo, scale);
        b->lo = lowest(b->lo, items[i].lo), b->hi = highest(b->hi, items[i].hi), b->count++;
    }
    bin sum = bins[BVH_BINS - 1];
    for (int i = BVH_BINS - 1; i > 0; i--) { // cost of everything from bin i on
        if (i < BVH_BINS - 1) {
            sum.lo = lowest(sum.lo, bins[i].lo), sum.hi = highest(sum.hi, bins[i].hi), sum.count += bins[i].count;
        }
        right[i] = sum.count ? (float)sum.count * half_area(sum.lo, sum.hi) : INFINITY;
    }
    sum = bins[0];
    for (int i = 1; i < BVH_BINS; i++) {
        const float cost = (sum.count ? (float)sum.count * half_area(sum.lo, sum.hi) : INFINITY) + right[i];
        if (cost < best) best = cost, *split = i;
        sum.lo = lowest(sum.lo, bins[i].lo), sum.hi = highest(sum.hi, bins[i].hi), sum.count += bins[i].count;
    }
    return best;
}

// Reorders the items of a node and returns how many belong to its first child; 0: the node stays a leaf.
static size_t split_items(bvh_item* items, size_t count, int depth) {
    v3 lo = items[0].center, hi = lo;
    if (count <= BVH_LEAF) return 0;
    for (size_t i = 1; i < count; i++) lo = lowest(lo, items[i].center), hi = highest(hi, items[i].center);
    float best = INFINITY;
    int best_axis = 0, best_split = 0;
    for (int axis = 0; axis < 3 && depth < BVH_SPLITS; axis++) {
        int split = 0;
        const float cost = find_split(items, count, axis, axis_of(lo, axis), axis_of(hi, axis), &split);
        if (cost < best) best = cost, best_axis = axis, best_split = split;
    }
    if (!(best < INFINITY)) return count / 2; // all in one place, or too deep
    const float low = axis_of(lo, best_axis), scale = (float)BVH_BINS / (axis_of(hi, best_axis) - low);
    size_t first = 0;
    for (size_t i = 0; i < count; i++)
        if (bin_of(items + i, best_axis, low, scale) < best_split) {
            const bvh_item swapped = items[first];
            items[first++] = items[i];
            items[i] = swapped;
        }
    return first;
}

static void build_nodes(tracer* t, bvh_item* items, size_t count) {
    typedef struct task { size_t node, begin, end; int depth; } task;
    task stack[BVH_STACK] = {{0, 0, 0, 0}};
    size_t node_count = 1;
    int waiting = 1;
    stack[0].end = count;
    while (waiting > 0) {
        const task now = stack[--waiting];
        bvh_node* node = t->nodes + now.node;
        node->lo = items[now.begin].lo, node->hi = items[now.begin].hi;
        for (size_t i = now.begin + 1; i < now.end; i++)
            node->lo = lowest(node->lo, items[i].lo), node->hi = highest(node->hi, items[i].hi);
        const size_t left = split_items(items + now.begin, now.end - now.begin, now.depth);
        node->count = left ? 0 : (uint32_t)(now.end - now.begin);
        node->first = left ? (uint32_t)node_count : (uint32_t)now.begin;
        if (!left) continue;
        const task a = {node_count, now.begin, now.begin + left, now.depth + 1},
                   b = {node_count + 1, now.begin + left, now.end, now.depth + 1};
        node_count += 2;
        stack[waiting++] = a;
        stack[waiting++] = b;
    }
}

// Returns NULL or what went wrong. end_tracer in either case.
static const char* start_tracer(tracer* out, const mesh_view* mesh) {
    const size_t count = mesh->triangle_count;
    bvh_item* items = (bvh_item*)malloc(count * sizeof *items);
    out->nodes = (bvh_node*)malloc(2 * count * sizeof *out->nodes);
    out->triangles = (bvh_triangle*)malloc(count * sizeof *out->triangles);
    if (!items || !out->nodes || !out->triangles || count == 0 || count > 0x7fffffffu) {
        free(items);
        return "out of memory";
    }
#define CORNER(i, k) (*(const v3*)((const char*)mesh->at + mesh->stride * mesh->corners[3 * (i) + (k)]))
    for (size_t i = 0; i < count; i++) {
        const v3 a = CORNER(i, 0), b = CORNER(i, 1), c = CORNER(i, 2);
        items[i].lo = lowest(a, lowest(b, c)), items[i].hi = highest(a, highest(b, c));
        items[i].center = mul(add(items[i].lo, items[i].hi), 0.5f);
        items[i].index = (uint32_t)i;
    }
    build_nodes(out, items, count);
    for (size_t i = 0; i < count; i++) {
        bvh_triangle* t = out->triangles + i;
        t->index = items[i].index;
        t->at = CORNER(t->index, 0);
        t->edge_u = sub(CORNER(t->index, 1), t->at);
        t->edge_v = sub(CORNER(t->index, 2), t->at);
    }
#undef CORNER
    free(items);
    return NULL;
}

static void end_tracer(tracer* t) {
    free(t->nodes);
    free(t->triangles);
}

// Distance at which a ray enters a box, infinite if it misses it.
static float enter_box(const bvh_node* node, v3 from, v3 inverse, float least, float most) {
    const float ax = (node->lo.x - from.x) * inverse.x, bx = (node->hi.x - from.x) * inverse.x;
    const float ay = (node->lo.y - from.y) * inverse.y, by = (node->hi.y - from.y) * inverse.y;
    const float az = (node->lo.z - from.z) * inverse.z, bz = (node->hi.z - from.z) * inverse.z;
    const float in = maxf(maxf(minf(ax, bx), minf(ay, by)), maxf(minf(az, bz), least));
    const float out = minf(minf(maxf(ax, bx), maxf(ay, by)), minf(maxf(az, bz), most));
    return in <= out * 1.0000004f ? in : INFINITY; // rounding must not lose flat boxes
}

// Moeller and Trumbore's test; edges are a hair wide, so that no ray slips between neighbours.
static int cross_triangle(const bvh_triangle* t, v3 from, v3 d, float least, float most, crossing* out) {
    const v3 p = cross(d, t->edge_v), q = sub(from, t->at);
    const float det = dot(t->edge_u, p);
    if (det == 0.0f) return 0;
    const float inverse = 1.0f / det, u = dot(q, p) * inverse;
    if (u < -1e-6f || u > 1.000001f) return 0;
    const v3 r = cross(q, t->edge_u);
    const float w = dot(d, r) * inverse, at = dot(t->edge_v, r) * inverse;
    if (w < -1e-6f || u + w > 1.000001f || !(at > least) || !(at < most)) return 0;
    out->t = at, out->u = u, out->v = w, out->triangle = t->index;
    return 1;
}

// The nearest crossing or, with `any`, the first one found.
static int walk_tree(const tracer* t, v3 from, v3 d, float least, float most, int any, crossing* out) {
    const v3 inverse = v(1.0f / (fabsf(d.x) > 1e-12f ? d.x : 1e-12f), 1.0f / (fabsf(d.y) > 1e-12f ? d.y : 1e-12f),
                         1.0f / (fabsf(d.z) > 1e-12f ? d.z : 1e-12f));
    uint32_t stack[BVH_STACK];
    const bvh_triangle* best = NULL;
    int waiting = 0;
    const bvh_node* node = t->nodes;
    float entry = enter_box(node, from, inverse, least, most);
    for (;;) {
        if (entry < most && node->count) {
            for (uint32_t i = node->first; i < node->first + node->count; i++)
                if (cross_triangle(t->triangles + i, from, d, least, most, out)) {
                    best = t->triangles + i;
                    most = out->t;
                    if (any) return 1;
                }
        } else if (entry < most) {
            const bvh_node *a = t->nodes + node->first, *b = a + 1;
            const float in_a = enter_box(a, from, inverse, least, most), in_b = enter_box(b, from, inverse, least, most);
            const bvh_node* closer = in_b < in_a ? b : a;
            if (maxf(in_a, in_b) < most) stack[waiting++] = node->first + (closer == a);
            entry = minf(in_a, in_b);
            if (entry < most) {
                node = closer;
                continue;
            }
        }
        if (waiting == 0) break;
        node = t->nodes + stack[--waiting];
        entry = node->count ? least : enter_box(node, from, inverse, least, most);
    }
    if (best) out->face = cross(best->edge_u, best->edge_v);
    return best != NULL;
}

static int is_crossed(const tracer* t, v3 from, v3 d, float least, float most) {
    crossing c;
    return walk_tree(t, from, d, least, most, 1, &c);
}

static int find_nearest(const tracer* t, v3 from, v3 d, float least, crossing* out) {
    return walk_tree(t, from, d, least, INFINITY, 0, out);
}

#endif // GSF_USE_EMBREE
#endif // SCENE_TRACE_H
