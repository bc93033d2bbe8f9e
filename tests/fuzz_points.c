// fuzz_points.c - the points of a transforms.json: a PLY with any columns, named by ply_file_path. Build line: fuzz.h.
#include "fuzz.h"

static const char scene_file[] =
    "{\"w\":8,\"h\":8,\"fl_x\":9,\"ply_file_path\":\"points.ply\",\"frames\":["
    "{\"file_path\":\"a.png\",\"transform_matrix\":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},"
    "{\"file_path\":\"b.png\",\"transform_matrix\":[[1,0,0,1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}";

static const uint8_t photo[] = { // black, 8 x 8
    137, 80, 78, 71, 13, 10, 26, 10, 0, 0, 0, 13, 73, 72, 68, 82, 0, 0, 0, 8, 0, 0, 0, 8, 8, 0, 0, 0, 0, 225, 100,
    225, 87, 0, 0, 0, 12, 73, 68, 65, 84, 120, 218, 99, 96, 160, 14, 0, 0, 0, 72, 0, 1, 16, 69, 239, 210, 0, 0, 0, 0,
    73, 69, 78, 68, 174, 66, 96, 130};

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    gsf_context ctx = fuzz_context(size);
    fuzz_file files[] = {{"transforms.json", scene_file, sizeof scene_file - 1},
                         {"points.ply", data, size},
                         {".png", photo, sizeof photo},
                         {NULL, NULL, 0}};
    gsf_scene scene;
    fuzz_hook_files(&ctx, files);
    const gsf_result result = gsf_splat_load_scene(&ctx, "fuzz/transforms.json", NULL, &scene);
    if (result == GSF_OK) {
        FUZZ_CHECK(scene.view_count == 2 && scene.point_count <= size);
        for (size_t i = 0; i < 3 * scene.point_count; i++) FUZZ_CHECK(isfinite(scene.points[i]));
        fuzz_use_scene(&ctx, &scene);
    } else {
        FUZZ_CHECK(result == GSF_ERROR_FORMAT || result == GSF_ERROR_UNSUPPORTED);
        FUZZ_CHECK(scene.state == NULL);
        fuzz_check_error(&ctx, "fuzz/points.ply:");
    }
    gsf_splat_destroy_scene(&ctx, &scene);
    FUZZ_CHECK(fuzz_live == 0);
    return 0;
}
