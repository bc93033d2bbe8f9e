// made_scene.h - the procedural scene of examples/make_scene.c for tests: make_scene() and removal of its files.
#ifndef MADE_SCENE_H
#define MADE_SCENE_H

#define MAKE_SCENE_NO_MAIN
#include "../examples/make_scene.c"

static void remove_scene(const char* folder, int views) {
    static const char* const files[] = {
        "sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin", "truth/visibility.bin", "truth/scene.json",
        "splits/test.txt", "splits/train_3.txt", "splits/train_6.txt", "splits/train_9.txt", "splits", "sparse/0", "sparse",
        "images", "truth", ""};
    char path[1200];
    for (int i = 0; i < views; i++) {
        snprintf(path, sizeof path, "%s/images/frame_%03d.png", folder, i + 1);
        remove(path);
        snprintf(path, sizeof path, "%s/truth/depth_%03d.npy", folder, i + 1);
        remove(path);
        snprintf(path, sizeof path, "%s/truth/normal_%03d.npy", folder, i + 1);
        remove(path);
    }
    for (size_t i = 0; i < sizeof files / sizeof *files; i++) {
        snprintf(path, sizeof path, "%s/%s", folder, files[i]);
        remove(path);
    }
}

#endif
