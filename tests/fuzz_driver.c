// fuzz_driver.c - runs a fuzz target on files and folders given on the command line (replays the corpus without
// libFuzzer). Each input is copied to a block of exactly its size, so that a sanitizer detects any read past its end.
#define _POSIX_C_SOURCE 200809L
#include <dirent.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

static size_t inputs;

static int replay_file(const char* path, size_t size) {
    FILE* file = fopen(path, "rb");
    uint8_t* data = malloc(size ? size : 1);
    int ok = file && data && fread(data, 1, size, file) == size;
    if (file) fclose(file);
    if (ok) {
        fprintf(stderr, "%s\n", path); // names the input of a crash
        if (size) {
            LLVMFuzzerTestOneInput(data, size);
        } else {
            LLVMFuzzerTestOneInput(NULL, 0);
        }
        inputs++;
    } else {
        fprintf(stderr, "%s: cannot be read\n", path);
    }
    free(data);
    return ok;
}

static int replay(const char* path) {
    struct stat info;
    if (stat(path, &info) != 0) {
        fprintf(stderr, "%s: no such file or folder\n", path);
        return 0;
    }
    if (!S_ISDIR(info.st_mode)) return replay_file(path, (size_t)info.st_size);
    DIR* folder = opendir(path);
    if (!folder) return 0;
    int ok = 1;
    for (const struct dirent* entry; (entry = readdir(folder)) != NULL;) {
        if (entry->d_name[0] == '.') continue;
        char name[4096];
        snprintf(name, sizeof name, "%s/%s", path, entry->d_name);
        ok &= replay(name);
    }
    closedir(folder);
    return ok;
}

int main(int argc, char** argv) {
    int ok = 1;
    for (int i = 1; i < argc; i++) ok &= replay(argv[i]);
    printf("%zu inputs replayed\n", inputs);
    return ok && inputs ? 0 : 1; // an empty corpus is a mistake, not a success
}
