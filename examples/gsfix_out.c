// gsfix_out.c - what gsfix reads and what it writes: it replaces and removes only files that it wrote itself
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <ctype.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <time.h>
#include <unistd.h>
#ifdef _WIN32
#define GSFIX_W_NAMES
#include "gsfix_windows.h"
#else
#include <dirent.h>
#include <sys/file.h>
#include <sys/stat.h>
#endif

#ifdef __APPLE__
#define st_ctim st_ctimespec
#endif

/* An output folder OUT belongs to the user. gsfix records what it has written there:
       OUT/.gsfix/manifest   "gsfix manifest 1", then a line per file: XXH64 of its bytes, size, command, name
       OUT/.gsfix/lock       locked by the run that is at work in OUT, as long as its process lives
       OUT/.gsfix/new        the file that is being written; renamed once it is whole
       OUT/.gsfix/draft      the file that another program is writing for gsfix
   A file is ours as long as the manifest lists its name with its size and digest; once edited or replaced it is the user's.
   The line is written before the file is renamed into place, so that after a kill at any moment both the old and the new
   file are known. A truncated last line is ignored. Names are relative, so a copy of OUT takes its manifest along. Each run
   rewrites the manifest.

   Before a run does any work, it claims every name that it may write. It fails there if a claimed name is taken by a file
   that is not ours, if a folder it needs is a link, or if a folder is an input or not writable. Everything is then written
   through the context's write hook, which accepts claimed names only. Folders below OUT are opened one by one and never
   through a link; OUT itself may be a link, since that is the user's choice.

   The read hook records what was read, to keep outputs out of input folders and to tie a checkpoint to its inputs. */

typedef struct out_place { dev_t device; ino_t inode; } out_place;
typedef struct out_input { out_place place; int is_folder; char* path; } out_input;

typedef struct out_line { // one line of the manifest
    char *name, *command;
    uint64_t size, digest;
    int written;           // written by this run and in place: ours without rereading while the following are unchanged
    out_place place;
    struct timespec changed;
} out_line;

struct gsfix_out {
    gsf_io plain; // the hooks that ours wrap
    out_input* inputs;
    gsfix_read_file* reads;
    char** claims; // names below OUT; '*' matches any text without '/'
    char** files;  // claimed paths outside OUT
    out_line* lines;
    size_t input_count, input_room, read_count, read_room, claim_count, claim_room;
    size_t file_count, file_room, line_count, line_room;
    int reads_ended;
    int root, own, lock, manifest, job;   // descriptors; -1: none
    uint64_t manifest_size;
    int is_new;                           // there was no manifest
    size_t existed;                       // length of the part of OUT's path that existed
    out_place root_place, job_place;
    gsfix_path job_path;
    char job_name[16];
    unsigned count; // number of temporary files outside OUT
    int unsaved;    // the clip's checkpoint could not be written
};

static out_place place_of(const struct stat* s) {
    const out_place place = {s->st_dev, s->st_ino};
    return place;
}

static int same_place(out_place a, out_place b) { return a.device == b.device && a.inode == b.inode; }

// ---- digests ---------------------------------------------------------------------
// XXH64 with seed 0, so that a manifest can be verified with `xxhsum`.

#define XXH_1 0x9E3779B185EBCA87u
#define XXH_2 0xC2B2AE3D27D4EB4Fu
#define XXH_3 0x165667B19E3779F9u
#define XXH_4 0x85EBCA77C2B2AE63u
#define XXH_5 0x27D4EB2F165667C5u

typedef struct xxh64 { uint64_t lanes[4], size; } xxh64;

static uint64_t xxh_load(const unsigned char* p, int bytes) {
    uint64_t v = 0;
    for (int i = 0; i < bytes; i++) v |= (uint64_t)p[i] << 8 * i;
    return v;
}

static uint64_t xxh_turn(uint64_t v, int bits) { return v << bits | v >> (64 - bits); }
static uint64_t xxh_round(uint64_t lane, uint64_t v) { return xxh_turn(lane + v * XXH_2, 31) * XXH_1; }

static void xxh_begin(xxh64* x) {
    const xxh64 fresh = {{XXH_1 + XXH_2, XXH_2, 0, 0u - XXH_1}, 0};
    *x = fresh;
}

static void xxh_blocks(xxh64* x, const unsigned char* p, size_t size) { // size: a multiple of 32
    for (const unsigned char* end = p + size; p < end; p += 32)
        for (int k = 0; k < 4; k++) x->lanes[k] = xxh_round(x->lanes[k], xxh_load(p + 8 * k, 8));
    x->size += size;
}

static uint64_t xxh_end(const xxh64* x, const unsigned char* p, size_t rest) { // rest: below 32
    static const int turns[4] = {1, 7, 12, 18};
    uint64_t h = XXH_5;
    if (x->size) {
        h = 0;
        for (int k = 0; k < 4; k++) h += xxh_turn(x->lanes[k], turns[k]);
        for (int k = 0; k < 4; k++) h = (h ^ xxh_round(0, x->lanes[k])) * XXH_1 + XXH_4;
    }
    h += x->size + rest;
    for (; rest >= 8; p += 8, rest -= 8) h = xxh_turn(h ^ xxh_round(0, xxh_load(p, 8)), 27) * XXH_1 + XXH_4;
    if (rest >= 4) {
        h = xxh_turn(h ^ xxh_load(p, 4) * XXH_1, 23) * XXH_2 + XXH_3;
        p += 4, rest -= 4;
    }
    for (; rest; p++, rest--) h = xxh_turn(h ^ *p * XXH_5, 11) * XXH_1;
    h = (h ^ h >> 33) * XXH_2;
    h = (h ^ h >> 29) * XXH_3;
    return h ^ h >> 32;
}

uint64_t gsfix_digest(const void* data, size_t size) {
    xxh64 x;
    xxh_begin(&x);
    xxh_blocks(&x, (const unsigned char*)data, size / 32 * 32);
    return xxh_end(&x, (const unsigned char*)data + size / 32 * 32, size % 32);
}

static int digest_file(int file, uint64_t* size, uint64_t* digest) { // from the current position to the end; 0: read error
    enum { BLOCK = 1 << 16 };
    unsigned char block[BLOCK];
    xxh64 x;
    xxh_begin(&x);
    for (size_t got = 0;;) {
        const ssize_t more = read(file, block + got, BLOCK - got);
        if (more < 0 && errno == EINTR) continue;
        if (more < 0) return 0;
        got += (size_t)more;
        if (more && got < BLOCK) continue;
        xxh_blocks(&x, block, got / 32 * 32);
        if (!more) {
            *size = x.size + got % 32;
            *digest = xxh_end(&x, block + got / 32 * 32, got % 32);
            return 1;
        }
        got = 0;
    }
}

// ---- inputs ----------------------------------------------------------------------

static gsf_result add_place(gsfix_app* app, const char* path, const struct stat* s) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    const out_place place = place_of(s);
    for (size_t i = 0; i < o->input_count; i++)
        if (same_place(o->inputs[i].place, place)) return GSF_OK;
    const out_input input = {place, S_ISDIR(s->st_mode), gsfix_copy_text(ctx, path, strlen(path))};
    gsf_result result = input.path ? gsfix_grow(ctx, (void**)&o->inputs, &o->input_room, o->input_count, sizeof input)
                                   : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) o->inputs[o->input_count++] = input;
    else gsf_free(ctx, input.path);
    return result;
}

gsf_result gsfix_add_input(gsfix_app* app, const char* path) {
    struct stat s;
    if (!path || stat(path, &s) != 0) return GSF_OK; // reported where it is needed
    gsf_result result = add_place(app, path, &s);
    if (result != GSF_OK || !S_ISREG(s.st_mode)) return result;
    gsfix_path folder = gsfix_pathf("%s", path);
    char* slash = strrchr(folder.s, '/');
    if (!slash) folder = gsfix_pathf(".");
    else slash[slash == folder.s] = 0;
    return stat(folder.s, &s) == 0 ? add_place(app, folder.s, &s) : GSF_OK;
}

gsf_result gsfix_add_scene_inputs(gsfix_app* app, const gsf_scene* scene) {
    gsf_result result = gsfix_add_input(app, scene->folder);
    for (size_t i = 0; i < scene->view_count && result == GSF_OK; i++)
        result = gsfix_add_input(app, gsf_splat_get_view_path(scene, i));
    return result;
}

static gsf_result add_options(gsfix_app* app) { // inputs named on the command line
    const gsfix_options* o = &app->o;
    const char* const paths[] = {o->masks, o->scene, o->path, o->ref_features, o->lora, o->model,
                                 o->restorer && strncmp(o->restorer, "dit:", 4) == 0 ? o->restorer + 4 : NULL};
    gsf_result result = GSF_OK;
    for (int i = 0; i < o->input_count && result == GSF_OK; i++) result = gsfix_add_input(app, o->inputs[i]);
    for (size_t i = 0; i < sizeof paths / sizeof *paths && result == GSF_OK; i++) result = gsfix_add_input(app, paths[i]);
    for (const char* p = o->refs; p && *p && result == GSF_OK; p += strcspn(p, ","), p += *p == ',')
        result = gsfix_add_input(app, gsfix_pathf("%.*s", (int)strcspn(p, ","), p).s);
    return result;
}

static const char* input_at(const gsfix_out* o, const struct stat* s) {
    for (size_t i = 0; i < o->input_count; i++)
        if (same_place(o->inputs[i].place, place_of(s))) return o->inputs[i].path;
    return NULL;
}

static gsf_result add_read(gsfix_app* app, const char* path, uint64_t size, uint64_t digest) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    const gsfix_read_file file = {gsfix_copy_text(ctx, path, strlen(path)), size, digest};
    gsf_result result = file.path ? gsfix_grow(ctx, (void**)&o->reads, &o->read_room, o->read_count, sizeof file)
                                  : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) o->reads[o->read_count++] = file;
    else gsf_free(ctx, file.path);
    return result;
}

static gsf_result read_hook(void* user, gsf_context* ctx, const char* path, void** data, size_t* size) {
    gsfix_app* app = (gsfix_app*)user;
    gsfix_out* o = app->out;
    gsf_result result = o->plain.read_fn(o->plain.user, ctx, path, data, size);
    if (result != GSF_OK || o->reads_ended) return result;
    for (size_t i = 0; i < o->file_count; i++)
        if (strcmp(o->files[i], path) == 0) return GSF_OK; // an output of this run before it was interrupted
    result = gsfix_add_input(app, path);
    if (result == GSF_OK) result = add_read(app, path, *size, gsfix_digest(*data, *size));
    if (result == GSF_OK) return GSF_OK;
    gsf_free(ctx, *data);
    *data = NULL;
    *size = 0;
    return result;
}

int gsfix_digest_file(const char* path, uint64_t* size, uint64_t* digest) {
    const int file = path ? open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK) : -1;
    const int readable = file >= 0 && digest_file(file, size, digest);
    if (file >= 0) close(file);
    return readable;
}

gsf_result gsfix_digest_input(gsfix_app* app, const char* path) {
    uint64_t size = 0, digest = 0;
    return gsfix_digest_file(path, &size, &digest) ? add_read(app, path, size, digest) : GSF_OK;
}

const gsfix_read_file* gsfix_end_inputs(gsfix_app* app, size_t* count) {
    app->out->reads_ended = 1;
    *count = app->out->read_count;
    return app->out->reads;
}

// ---- folders below OUT -------------------------------------------------------------

// Opens the folder part of `name` without following links; *base is the rest of the name. Returns -1 and sets errno on
// failure.
static int open_folder(int root, const char* name, int make, const char** base) {
#ifdef _WIN32
    int at = gsfix_w_dup(root);
#else
    int at = fcntl(root, F_DUPFD_CLOEXEC, 0);
#endif
    for (const char* slash; at >= 0 && (slash = strchr(name, '/')) != NULL; name = slash + 1) {
        const gsfix_path part = gsfix_pathf("%.*s", (int)(slash - name), name);
        int next = -1;
        if (!part.s[0] || strcmp(part.s, ".") == 0 || strcmp(part.s, "..") == 0) errno = EINVAL;
        else if (!make || mkdirat(at, part.s, 0777) == 0 || errno == EEXIST)
            next = openat(at, part.s, O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
        const int reason = errno;
        close(at);
        errno = reason;
        at = next;
    }
    *base = name;
    return at;
}

static const char* folder_trouble(int reason) {
    return reason == ELOOP || reason == ENOTDIR ? "a link or a file is where a folder is needed" : strerror(reason);
}

static DIR* list_folder(int folder) {
    const int own = openat(folder, ".", O_RDONLY | O_DIRECTORY | O_CLOEXEC); // a descriptor with its own directory offset
    DIR* list = own >= 0 ? fdopendir(own) : NULL;
    if (!list && own >= 0) close(own);
    return list;
}

// Removes the contents of a folder that gsfix made for a restorer. Links are removed, their targets are not.
static int remove_below(int folder, dev_t device) {
    DIR* list = list_folder(folder);
    int ok = list != NULL;
    for (struct dirent* entry; ok && (entry = readdir(list)) != NULL;) {
        struct stat s;
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0) continue;
        if (fstatat(folder, entry->d_name, &s, AT_SYMLINK_NOFOLLOW) != 0) continue;
        if (!S_ISDIR(s.st_mode)) {
            ok = unlinkat(folder, entry->d_name, 0) == 0;
            continue;
        }
        const int child = openat(folder, entry->d_name, O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
        ok = child >= 0 && s.st_dev == device && remove_below(child, device) &&
             unlinkat(folder, entry->d_name, AT_REMOVEDIR) == 0;
        if (child >= 0) close(child);
    }
    if (list) closedir(list);
    return ok;
}

static int write_bytes(int file, const void* data, size_t size) {
    for (const char* p = (const char*)data; size;) {
        const ssize_t n = write(file, p, size);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return 0;
        p += n;
        size -= (size_t)n;
    }
    return 1;
}

// Writes a new file and removes it again if it cannot be written completely. Returns 0 and sets errno on failure.
static int write_new(int folder, const char* name, const void* data, size_t size, int durable) {
    const int file = openat(folder, name, O_WRONLY | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC, 0666);
    if (file < 0) return 0;
    int ok = write_bytes(file, data, size) && (!durable || fsync(file) == 0 || errno == EINVAL);
    int reason = errno;
    if (close(file) != 0 && ok) ok = 0, reason = errno;
    if (!ok) unlinkat(folder, name, 0);
    errno = reason;
    return ok;
}

// ---- manifest --------------------------------------------------------------------

static const char manifest_head[] = "gsfix manifest 1\n";

// Bytes that would break the line format become %XX.
static void put_name(gsf_context* ctx, gsf_buffer* text, const char* name) {
    for (; *name; name++) {
        if ((unsigned char)*name > 0x20 && *name != '%' && *name != 0x7f) gsf_append_bytes(ctx, text, name, 1);
        else gsf_append_text(ctx, text, "%%%02X", (unsigned)(unsigned char)*name);
    }
}

static char* take_name(gsf_context* ctx, const char* from, size_t size) {
    char* name = gsfix_copy_text(ctx, from, size);
    char* to = name;
    for (const char* p = name; p && *p; p++) {
        unsigned byte; // two digits: sscanf would also take a space or sign and one, and the end of the name for the second
        if (*p == '%' && isxdigit((unsigned char)p[1]) && isxdigit((unsigned char)p[2]) && sscanf(p + 1, "%2x", &byte) == 1)
            *to++ = (char)byte, p += 2;
        else *to++ = *p;
    }
    if (to) *to = 0;
    return name;
}

static gsf_result add_line(gsf_context* ctx, gsfix_out* o, const out_line* line) { // takes ownership of the line's memory
    const gsf_result result = line->name && line->command
                                  ? gsfix_grow(ctx, (void**)&o->lines, &o->line_room, o->line_count, sizeof *line)
                                  : GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) {
        o->lines[o->line_count++] = *line;
        return GSF_OK;
    }
    gsf_free(ctx, line->name);
    gsf_free(ctx, line->command);
    return result;
}

static void drop_line(gsf_context* ctx, gsfix_out* o, size_t i) {
    gsf_free(ctx, o->lines[i].name);
    gsf_free(ctx, o->lines[i].command);
    memmove(o->lines + i, o->lines + i + 1, (--o->line_count - i) * sizeof *o->lines);
}

static void print_line(gsf_context* ctx, gsf_buffer* text, const out_line* line) {
    gsf_append_text(ctx, text, "%016llx %llu %s ", (unsigned long long)line->digest, (unsigned long long)line->size,
                    line->command);
    put_name(ctx, text, line->name);
    gsf_append_bytes(ctx, text, "\n", 1);
}

// Malformed lines are ignored, so that they claim nothing.
static gsf_result parse_manifest(gsf_context* ctx, gsfix_out* o, const char* text, size_t size) {
    gsf_result result = GSF_OK;
    for (const char *p = text, *end; result == GSF_OK && (end = (const char*)memchr(p, '\n', size - (size_t)(p - text)));
         p = end + 1) {
        unsigned long long digest, bytes;
        char command[16];
        int at = 0;
        const gsfix_path line = gsfix_pathf("%.*s", (int)(end - p < 4000 ? end - p : 4000), p);
        if (sscanf(line.s, "%16llx %llu %15s %n", &digest, &bytes, command, &at) != 3 || !at || !line.s[at]) continue;
        const out_line fresh = {take_name(ctx, line.s + at, strlen(line.s + at)),
                                gsfix_copy_text(ctx, command, strlen(command)), bytes, digest, 0, {0, 0}, {0, 0}};
        if (fresh.name && fresh.command && !*fresh.name) { // an escaped zero
            gsf_free(ctx, fresh.name);
            gsf_free(ctx, fresh.command);
            continue;
        }
        result = add_line(ctx, o, &fresh);
    }
    return result;
}

static gsf_result load_manifest(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    struct stat s;
    gsf_result result = GSF_OK;
    const int file = openat(o->own, "manifest", O_RDONLY | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC);
    o->is_new = file < 0 && errno == ENOENT;
    if (o->is_new) return GSF_OK;
    if (file < 0 || fstat(file, &s) != 0 || !S_ISREG(s.st_mode) || s.st_size > 1 << 28) {
        result = gsf_fail(ctx, GSF_ERROR_IO, "%s/.gsfix/manifest: cannot be used", app->o.out);
    } else {
        char* text = (char*)gsf_alloc(ctx, (size_t)s.st_size + 1, 1);
        size_t size = 0;
        for (ssize_t n = 1; text && n > 0 && size < (size_t)s.st_size; size += n > 0 ? (size_t)n : 0)
            n = read(file, text + size, (size_t)s.st_size - size);
        if (!text) result = GSF_ERROR_OUT_OF_MEMORY;
        else if (size < sizeof manifest_head - 1 || memcmp(text, manifest_head, sizeof manifest_head - 1) != 0)
            result = gsf_fail(ctx, GSF_ERROR_IO, "%s/.gsfix/manifest: not a manifest of this version of gsfix", app->o.out);
        else result = parse_manifest(ctx, o, text, size);
        gsf_free(ctx, text);
    }
    if (file >= 0) close(file);
    return result;
}

static int is_written(const out_line* line, const struct stat* s) {
    return line->written && same_place(line->place, place_of(s)) && line->size == (uint64_t)s->st_size &&
           line->changed.tv_sec == s->st_ctim.tv_sec && line->changed.tv_nsec == s->st_ctim.tv_nsec;
}

// Is the file `base` in the folder, listed as `name`, as gsfix wrote it? -1: there is no such file. *which: its line.
static int look_at(const gsfix_out* o, int folder, const char* base, const char* name, struct stat* s, size_t* which) {
    uint64_t size = 0, digest = 0;
    int known = 0;
    if (fstatat(folder, base, s, AT_SYMLINK_NOFOLLOW) != 0) return errno == ENOENT ? -1 : 0;
    if (!S_ISREG(s->st_mode)) return 0;
    for (size_t i = o->line_count; i-- > 0;) {
        const out_line* line = o->lines + i;
        if (line->size != (uint64_t)s->st_size || strcmp(line->name, name) != 0) continue;
        if (!known && !is_written(line, s)) {
            const int file = openat(folder, base, O_RDONLY | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC);
            const int readable = file >= 0 && digest_file(file, &size, &digest);
            if (file >= 0) close(file);
            if (!readable) return 0;
            known = 1;
        }
        if (known ? line->digest == digest && line->size == size : is_written(line, s)) {
            if (which) *which = i;
            return 1;
        }
    }
    return 0;
}

static int is_absolute(const char* name) { // as gsfix_absolute makes them
#ifdef _WIN32
    return name[0] == '/' || (name[0] && name[1] == ':');
#else
    return name[0] == '/';
#endif
}

// Opens the folder of a name in the manifest.
static int folder_of(const gsfix_out* o, const char* name, const char** base) {
    if (!is_absolute(name)) return open_folder(o->root, name, 0, base);
    const char* slash = strrchr(name, '/');
    *base = slash + 1;
    return open(gsfix_pathf("%.*s/", (int)(slash - name), name).s, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
}

// Rewrites the manifest as a new file without lines whose files are gone; this also drops truncated lines and hard links.
static gsf_result renew_manifest(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    gsf_buffer text = {0};
    gsf_append_bytes(ctx, &text, manifest_head, sizeof manifest_head - 1);
    for (size_t i = o->line_count; i-- > 0;) {
        const char* base;
        struct stat s;
        size_t which = 0, same = 0;
        const int folder = folder_of(o, o->lines[i].name, &base);
        int keep = folder >= 0 && fstatat(folder, base, &s, AT_SYMLINK_NOFOLLOW) == 0 && S_ISREG(s.st_mode) &&
                   (uint64_t)s.st_size == o->lines[i].size;
        for (size_t k = 0; keep && k < o->line_count; k++) same += strcmp(o->lines[k].name, o->lines[i].name) == 0;
        if (keep && same > 1) keep = look_at(o, folder, base, o->lines[i].name, &s, &which) == 1 && which == i;
        if (folder >= 0) close(folder);
        if (!keep) drop_line(ctx, o, i);
    }
    for (size_t i = 0; i < o->line_count; i++) print_line(ctx, &text, o->lines + i);
    unlinkat(o->own, "new", 0);
    unlinkat(o->own, "draft", 0);
    gsf_result result = text.failed ? GSF_ERROR_OUT_OF_MEMORY : GSF_OK;
    if (result == GSF_OK && (!write_new(o->own, "new", text.data, text.size, 1) ||
                             renameat(o->own, "new", o->own, "manifest") != 0 ||
                             (o->manifest = openat(o->own, "manifest", O_WRONLY | O_APPEND | O_NOFOLLOW | O_CLOEXEC)) < 0))
        result = gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be written: %s", app->o.out, strerror(errno));
    o->manifest_size = text.size;
    gsf_destroy_buffer(ctx, &text);
    return result;
}

// Adds a line for a file that is about to be renamed into place. Returns 0, sets errno and leaves the manifest unchanged on
// failure.
static int enter_line(gsfix_app* app, const char* name, uint64_t size, uint64_t digest, int durable) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    gsf_buffer text = {0};
    const out_line line = {gsfix_copy_text(ctx, name, strlen(name)), gsfix_copy_text(ctx, app->command, strlen(app->command)),
                           size, digest, 0, {0, 0}, {0, 0}};
    int ok = add_line(ctx, o, &line) == GSF_OK;
    errno = ENOMEM;
    if (!ok) return 0;
    print_line(ctx, &text, &line);
    ok = !text.failed && write_bytes(o->manifest, text.data, text.size);
    if (ok) o->manifest_size += text.size;
    else {
        const int reason = errno;
        if (ftruncate(o->manifest, (off_t)o->manifest_size) != 0) errno = reason;
        drop_line(ctx, o, o->line_count - 1);
        errno = reason;
    }
    gsf_destroy_buffer(ctx, &text);
    return ok && (!durable || fsync(o->manifest) == 0 || errno == EINVAL);
}

// The file of the last line is in place: drops older lines for the same name.
static void settle_line(gsf_context* ctx, gsfix_out* o, int folder, const char* base) {
    struct stat s;
    out_line* last = o->lines + o->line_count - 1;
    if (fstatat(folder, base, &s, AT_SYMLINK_NOFOLLOW) == 0) {
        last->written = 1;
        last->place = place_of(&s);
        last->changed = s.st_ctim;
    }
    for (size_t i = o->line_count - 1; i-- > 0;)
        if (strcmp(o->lines[i].name, o->lines[o->line_count - 1].name) == 0) drop_line(ctx, o, i);
}

// ---- claims ----------------------------------------------------------------------

static int matches(const char* pattern, const char* name) {
    for (; *pattern != '*'; pattern++, name++) {
        if (*pattern != *name) return 0;
        if (!*name) return 1;
    }
    for (;; name++) {
        if (matches(pattern + 1, name)) return 1;
        if (!*name || *name == '/') return 0;
    }
}

gsf_result gsfix_claim(gsfix_app* app, const char* format, ...) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    char name[4096];
    va_list args;
    va_start(args, format);
    const int n = vsnprintf(name, sizeof name, format, args);
    va_end(args);
    if (n < 0 || (size_t)n >= sizeof name) return gsf_fail(ctx, GSF_ERROR_IO, "%s: too long a name", app->o.out);
    gsf_result result = gsfix_grow(ctx, (void**)&o->claims, &o->claim_room, o->claim_count, sizeof *o->claims);
    if (result == GSF_OK) {
        o->claims[o->claim_count] = gsfix_copy_text(ctx, name, (size_t)n);
        if (!o->claims[o->claim_count]) return GSF_ERROR_OUT_OF_MEMORY;
        o->claim_count++;
    }
    return result;
}

static gsf_result not_ours(gsfix_app* app, const char* name) {
    return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%s: not written by gsfix, or changed since: it stays, and nothing is done "
                    "(move it away or choose another --out)", app->o.out, name);
}

static gsf_result check_name(gsfix_app* app, int folder, const char* base, const char* name) {
    struct stat s;
    errno = 0;
    const int ours = look_at(app->out, folder, base, name, &s, NULL);
    if (ours < 0) return GSF_OK;
    if (!ours && errno == ENAMETOOLONG)
        return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%s: %s", app->o.out, name, strerror(errno));
    if (!ours) return not_ours(app, name);
    if (!input_at(app->out, &s)) return GSF_OK;
    return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%s: an input, and not to be replaced (choose another --out)", app->o.out,
                    name);
}

static gsf_result check_matches(gsfix_app* app, int folder, const char* base, const char* pattern) {
    DIR* list = list_folder(folder);
    gsf_result result = GSF_OK;
    if (!list) return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%s: %s", app->o.out, pattern, strerror(errno));
    for (struct dirent* entry; result == GSF_OK && (entry = readdir(list)) != NULL;)
        if (matches(base, entry->d_name))
            result = check_name(app, folder, entry->d_name,
                                gsfix_pathf("%.*s%s", (int)(base - pattern), pattern, entry->d_name).s);
    closedir(list);
    return result;
}

static gsf_result check_folder(gsfix_app* app, int folder, const char* name, int length) {
    struct stat s;
    const char* slash = length ? "/" : "";
    const char* input = fstat(folder, &s) == 0 ? input_at(app->out, &s) : NULL;
    if (input)
        return gsf_fail(&app->ctx, GSF_ERROR_IO,
                        "%s%s%.*s: input is read from there (%s), so nothing is written there (choose another --out)",
                        app->o.out, slash, length, name, input);
    if (length && s.st_dev != app->out->root_place.device)
        return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%.*s: on another file system than %s", app->o.out, length, name,
                        app->o.out);
    if (faccessat(folder, ".", W_OK | X_OK, AT_EACCESS) != 0)
        return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s%s%.*s: cannot be written: %s", app->o.out, slash, length, name,
                        strerror(errno));
    return GSF_OK;
}

static gsf_result check_claim(gsfix_app* app, const char* claim) {
    const char *base, *slash = strrchr(claim, '/');
    const int length = slash ? (int)(slash - claim) : 0;
    const int folder = open_folder(app->out->root, claim, 0, &base);
    if (folder < 0 && errno == ENOENT) return GSF_OK;
    if (folder < 0)
        return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%.*s: %s", app->o.out, length, claim, folder_trouble(errno));
    gsf_result result = check_folder(app, folder, claim, length);
    if (result == GSF_OK)
        result = strchr(base, '*') ? check_matches(app, folder, base, claim) : check_name(app, folder, base, claim);
    close(folder);
    return result;
}

// ---- opening and closing OUT -------------------------------------------------------

static gsf_result take_lock(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    for (;;) {
        struct stat mine, there;
        o->lock = openat(o->own, "lock", O_RDWR | O_CREAT | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC, 0666);
        if (o->lock < 0) return gsf_fail(ctx, GSF_ERROR_IO, "%s/.gsfix/lock: %s", app->o.out, strerror(errno));
        int locked;
        while ((locked = flock(o->lock, LOCK_EX | LOCK_NB)) != 0 && errno == EINTR) {}
        if (locked != 0 && errno == EWOULDBLOCK)
            return gsf_fail(ctx, GSF_ERROR_IO, "%s: another gsfix is at work there", app->o.out);
        if (locked != 0) {
            gsf_log(ctx, GSF_LOG_WARNING, "%s: cannot be locked (%s); do not start a second run there", app->o.out,
                    strerror(errno));
            return GSF_OK;
        }
        if (fstat(o->lock, &mine) == 0 && fstatat(o->own, "lock", &there, AT_SYMLINK_NOFOLLOW) == 0 &&
            same_place(place_of(&mine), place_of(&there)))
            return GSF_OK;
        close(o->lock); // its owner removed it just before exiting
    }
}

// A .gsfix without a manifest is ours if it contains only what a run that was killed at its start leaves.
static gsf_result check_own(gsfix_app* app) {
    DIR* list = list_folder(app->out->own);
    gsf_result result = GSF_OK;
    for (struct dirent* entry; list && result == GSF_OK && (entry = readdir(list)) != NULL;)
        if (strcmp(entry->d_name, ".") && strcmp(entry->d_name, "..") && strcmp(entry->d_name, "lock") &&
            strcmp(entry->d_name, "new") && strcmp(entry->d_name, "draft"))
            result = gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/.gsfix/%s: not written by gsfix (choose another --out)", app->o.out,
                              entry->d_name);
    if (list) closedir(list);
    return result;
}

static size_t existing_part(const char* path) { // length of the leading part that exists
    gsfix_path part = gsfix_pathf("%s", path);
    struct stat s;
    while (part.s[0] && lstat(part.s, &s) != 0) {
        char* slash = strrchr(part.s, '/');
        part.s[slash ? slash - part.s : 0] = 0;
    }
    return strlen(part.s);
}

// Removes the folders of OUT's path that were created and are empty.
static void remove_made(const gsfix_out* o, const char* path) {
    for (gsfix_path part = gsfix_pathf("%s", path); strlen(part.s) > o->existed;) {
        char* slash = strrchr(part.s, '/');
        rmdir(part.s);
        part.s[slash ? slash - part.s : 0] = 0;
    }
}

static gsf_result open_root(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    struct stat s;
    o->existed = existing_part(app->o.out);
    gsf_result result = gsfix_make_folder(ctx, app->o.out);
    if (result != GSF_OK) return result;
    o->root = open(app->o.out, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (o->root < 0 || fstat(o->root, &s) != 0)
        return gsf_fail(ctx, GSF_ERROR_IO, "%s: folder cannot be used: %s", app->o.out, strerror(errno));
    o->root_place = place_of(&s);
    result = check_folder(app, o->root, "", 0);
    if (result != GSF_OK) return result;
    if (mkdirat(o->root, ".gsfix", 0777) != 0 && errno != EEXIST)
        return gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be written: %s", app->o.out, strerror(errno));
    o->own = openat(o->root, ".gsfix", O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
    if (o->own < 0) return gsf_fail(ctx, GSF_ERROR_IO, "%s/.gsfix: %s", app->o.out, folder_trouble(errno));
    return check_folder(app, o->own, ".gsfix", 6);
}

gsf_result gsfix_open_out(gsfix_app* app) {
    gsfix_out* o = app->out;
    gsf_result result = add_options(app);
    if (result == GSF_OK) result = open_root(app);
    if (result == GSF_OK) result = take_lock(app);
    if (result == GSF_OK) result = load_manifest(app);
    if (result == GSF_OK && o->is_new) result = check_own(app);
    for (size_t i = 0; i < o->claim_count && result == GSF_OK; i++) result = check_claim(app, o->claims[i]);
    if (result == GSF_OK) result = renew_manifest(app);
    return result;
}

static int is_claimed(const gsfix_out* o, const char* name, int by_name) {
    for (size_t i = 0; i < o->claim_count; i++)
        if (by_name ? strcmp(o->claims[i], name) == 0 : matches(o->claims[i], name)) return 1;
    return 0;
}

gsf_result gsfix_remove_output(gsfix_app* app, const char* name) {
    struct stat s;
    const char* base;
    const int folder = open_folder(app->out->root, name, 0, &base);
    gsf_result result = GSF_OK;
    if (folder >= 0 && look_at(app->out, folder, base, name, &s, NULL) == 1 && unlinkat(folder, base, 0) != 0)
        result = gsf_fail(&app->ctx, GSF_ERROR_IO, "%s/%s: cannot be removed: %s", app->o.out, name, strerror(errno));
    if (folder >= 0) close(folder);
    return result;
}

gsf_result gsfix_remove_stale(gsfix_app* app) {
    gsfix_out* o = app->out;
    gsf_result result = GSF_OK;
    for (size_t i = 0; i < o->line_count && result == GSF_OK; i++) {
        const out_line* line = o->lines + i;
        if (strcmp(line->command, app->command) == 0 && !is_absolute(line->name) && !is_claimed(o, line->name, 1))
            result = gsfix_remove_output(app, line->name);
    }
    return result;
}

int gsfix_query_output(gsfix_app* app, const char* name, uint64_t* size, uint64_t* digest) {
    struct stat s;
    const char* base;
    size_t which = 0;
    const int folder = open_folder(app->out->root, name, 0, &base);
    const int ours = folder >= 0 && look_at(app->out, folder, base, name, &s, &which) == 1;
    if (folder >= 0) close(folder);
    *size = ours ? app->out->lines[which].size : 0;
    *digest = ours ? app->out->lines[which].digest : 0;
    return ours;
}

int gsfix_has_output(gsfix_app* app, const char* name) {
    uint64_t size, digest;
    return gsfix_query_output(app, name, &size, &digest);
}

// ---- writing ---------------------------------------------------------------------

static gsf_result unwritten(gsf_context* ctx, const char* path, int reason) {
    return gsf_fail(ctx, GSF_ERROR_IO, "%s: cannot be written: %s", path, folder_trouble(reason));
}

// Files directly in OUT (results and checkpoint) are synced to disk, so that they survive a power failure.
static gsf_result write_output(gsfix_app* app, gsf_context* ctx, const char* path, const char* name, const void* data,
                               size_t size) {
    gsfix_out* o = app->out;
    const char* base = name;
    struct stat s;
    const int durable = !strchr(name, '/');
    if (!is_claimed(o, name, 0)) return gsf_fail(ctx, GSF_ERROR_IO, "%s: the command did not claim this name", path);
    const int folder = open_folder(o->root, name, 1, &base);
    if (folder < 0) return unwritten(ctx, path, errno);
    gsf_result result = look_at(o, folder, base, name, &s, NULL) == 0 ? not_ours(app, name) : GSF_OK;
    if (result == GSF_OK && !write_new(o->own, "new", data, size, durable)) result = unwritten(ctx, path, errno);
    if (result == GSF_OK) {
        if (enter_line(app, name, size, gsfix_digest(data, size), durable) && renameat(o->own, "new", folder, base) == 0) {
            settle_line(&app->ctx, o, folder, base);
        } else {
            const int reason = errno;
            unlinkat(o->own, "new", 0);
            result = unwritten(ctx, path, reason);
        }
    }
    close(folder);
    return result;
}

static gsf_result write_job_file(gsfix_app* app, gsf_context* ctx, const char* path, const char* name, const void* data,
                                 size_t size) {
    const char* base;
    const int folder = open_folder(app->out->job, name, 1, &base);
    if (folder < 0) return unwritten(ctx, path, errno);
    unlinkat(folder, base, 0); // left by the previous window
    const gsf_result result = write_new(folder, base, data, size, 0) ? GSF_OK : unwritten(ctx, path, errno);
    close(folder);
    return result;
}

// A claimed file outside OUT: it is either new or was written by an earlier run with this OUT.
static gsf_result write_file(gsfix_app* app, gsf_context* ctx, const char* path, const void* data, size_t size) {
    gsfix_out* o = app->out;
    gsfix_path name;
    struct stat s;
    const char* base;
    // Devices and pipes are written to, not replaced.
    if (stat(path, &s) == 0 && (S_ISCHR(s.st_mode) || S_ISFIFO(s.st_mode)))
        return o->plain.write_fn(o->plain.user, ctx, path, data, size);
    name = gsfix_absolute(path);
    const int folder = name.s[0] ? folder_of(o, name.s, &base) : -1;
    if (folder < 0) return unwritten(ctx, path, errno);
    const int there = look_at(o, folder, base, name.s, &s, NULL);
    const gsfix_path temporary = gsfix_pathf(".gsfix-%ld-%u", (long)getpid(), o->count++);
    gsf_result result = GSF_OK;
    if (there == 0) {
        result = gsf_fail(ctx, GSF_ERROR_IO, "%s: is there already, and not replaced", path);
    } else if (!write_new(folder, temporary.s, data, size, 1)) {
        result = unwritten(ctx, path, errno);
    } else {
        int ok = o->manifest < 0 || enter_line(app, name.s, size, gsfix_digest(data, size), 1);
        if (ok && there < 0) { // link() fails if the name was taken meanwhile
            ok = linkat(folder, temporary.s, folder, base, 0) == 0;
            // A file system without hard links.
            if (!ok && errno != EEXIST) ok = renameat(folder, temporary.s, folder, base) == 0;
        } else if (ok) {
            ok = renameat(folder, temporary.s, folder, base) == 0;
        }
        if (!ok) result = unwritten(ctx, path, errno);
        unlinkat(folder, temporary.s, 0);
        if (ok && o->manifest >= 0) settle_line(&app->ctx, o, folder, base);
    }
    close(folder);
    return result;
}

static const char* below(const char* path, const char* folder) { // the part of path after "folder/", or NULL
    const size_t n = strlen(folder);
    if (!n || strncmp(path, folder, n) != 0 || (path[n] != '/' && folder[n - 1] != '/')) return NULL;
    return path + n + strspn(path + n, "/");
}

static gsf_result write_hook(void* user, gsf_context* ctx, const char* path, const void* data, size_t size) {
    gsfix_app* app = (gsfix_app*)user;
    gsfix_out* o = app->out;
    const char* name;
    if (o->job >= 0 && (name = below(path, o->job_path.s)) != NULL) return write_job_file(app, ctx, path, name, data, size);
    if (o->root >= 0 && (name = below(path, app->o.out)) != NULL) {
        const gsf_result result = write_output(app, ctx, path, name, data, size);
        if (result != GSF_ERROR_IO || strcmp(name, "dit.checkpoint") != 0) return result;
        if (!o->unsaved) gsf_log(ctx, GSF_LOG_WARNING, "going on without the clip's checkpoint: %s", ctx->error);
        o->unsaved = 1;
        ctx->error[0] = 0;
        return GSF_OK; // it only saves time after an interruption; no result depends on it
    }
    for (size_t i = 0; i < o->file_count; i++)
        if (strcmp(o->files[i], path) == 0) return write_file(app, ctx, path, data, size);
    return gsf_fail(ctx, GSF_ERROR_IO, "%s: the command did not claim this name", path);
}

gsfix_path gsfix_absolute(const char* path) {
    const char* slash = strrchr(path, '/');
    const gsfix_path folder = slash ? gsfix_pathf("%.*s/", (int)(slash - path), path) : gsfix_pathf(".");
    char* real = realpath(folder.s, NULL);
    gsfix_path absolute = {""};
    if (real) absolute = gsfix_pathf("%s/%s", strcmp(real, "/") ? real : "", slash ? slash + 1 : path);
    free(real);
    return absolute;
}

gsf_result gsfix_claim_file(gsfix_app* app, const char* path) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    struct stat s;
    const char *base, *inner = path && o->root >= 0 ? below(path, app->o.out) : NULL;
    if (!path) return GSF_OK;
    if (inner && is_claimed(o, inner, 0))
        return gsf_fail(ctx, GSF_ERROR_IO, "%s: the command writes another file of this name", path);
    if (inner) {
        const gsf_result result = gsfix_claim(app, "%s", inner);
        return result == GSF_OK ? check_claim(app, inner) : result;
    }
    const gsfix_path name = gsfix_absolute(path);
    const int folder = name.s[0] ? folder_of(o, name.s, &base) : -1;
    gsf_result result = GSF_OK;
    if (folder < 0 || !*base) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: no such folder to write into", path);
    else if (stat(path, &s) == 0 && (S_ISCHR(s.st_mode) || S_ISFIFO(s.st_mode))) {}
    else if (look_at(o, folder, base, name.s, &s, NULL) == 0)
        result = gsf_fail(ctx, GSF_ERROR_IO,
                          "%s: is there already, and not replaced (move it away or choose another name)", path);
    else if (faccessat(folder, ".", W_OK | X_OK, AT_EACCESS) != 0) result = unwritten(ctx, path, errno);
    if (folder >= 0) close(folder);
    if (result == GSF_OK) result = gsfix_grow(ctx, (void**)&o->files, &o->file_room, o->file_count, sizeof *o->files);
    if (result == GSF_OK) {
        o->files[o->file_count] = gsfix_copy_text(ctx, path, strlen(path));
        if (!o->files[o->file_count]) return GSF_ERROR_OUT_OF_MEMORY;
        o->file_count++;
    }
    return result;
}

// ---- drafts ----------------------------------------------------------------------

gsf_result gsfix_begin_draft(gsfix_app* app, gsfix_path* path) {
    char* real = realpath(app->o.out, NULL);
    if (!real) return gsf_fail(&app->ctx, GSF_ERROR_IO, "%s: %s", app->o.out, strerror(errno));
    *path = gsfix_pathf("%s/.gsfix/draft", real);
    free(real);
    gsfix_drop_draft(app);
    return GSF_OK;
}

gsf_result gsfix_publish_draft(gsfix_app* app, const char* path) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    void* data = NULL;
    size_t size = 0;
    gsf_result result = o->plain.read_fn(o->plain.user, ctx, gsfix_pathf("%s/.gsfix/draft", app->o.out).s, &data, &size);
    if (result == GSF_OK && !size) result = gsf_fail(ctx, GSF_ERROR_IO, "%s: is empty", path);
    if (result == GSF_OK) result = gsf_write_file(ctx, path, data, size);
    gsf_free(ctx, data);
    gsfix_drop_draft(app);
    return result;
}

void gsfix_drop_draft(gsfix_app* app) { unlinkat(app->out->own, "draft", 0); }

// ---- job folders -----------------------------------------------------------------

gsf_result gsfix_make_job(gsfix_app* app, const char** path) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    struct timespec now;
    struct stat s;
    clock_gettime(CLOCK_REALTIME, &now);
    for (uint64_t i = 0; o->job < 0 && i < 1000; i++) {
        const uint64_t bits = gsf_draw_bits((uint64_t)now.tv_nsec ^ (uint64_t)now.tv_sec << 30, (uint64_t)getpid(), i);
        snprintf(o->job_name, sizeof o->job_name, "job-%06x", (unsigned)(bits >> 40));
        if (mkdirat(o->root, o->job_name, 0777) == 0)
            o->job = openat(o->root, o->job_name, O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
        else if (errno != EEXIST) break;
    }
    // Absolute, since a command may change its working directory.
    char* real = o->job >= 0 ? realpath(app->o.out, NULL) : NULL;
    if (!real || fstat(o->job, &s) != 0)
        return gsf_fail(ctx, GSF_ERROR_IO, "%s/%s: folder cannot be made: %s", app->o.out, o->job_name, strerror(errno));
    o->job_place = place_of(&s);
    o->job_path = gsfix_pathf("%s/%s", real, o->job_name);
    free(real);
    *path = o->job_path.s;
    return GSF_OK;
}

gsf_result gsfix_empty_job(gsfix_app* app, const char* name) {
    gsfix_out* o = app->out;
    const char* base;
    const int folder = open_folder(o->job, gsfix_pathf("%s/", name).s, 1, &base);
    const int ok = folder >= 0 && remove_below(folder, o->job_place.device);
    const int reason = errno;
    if (folder >= 0) close(folder);
    if (ok) return GSF_OK;
    return gsf_fail(&app->ctx, GSF_ERROR_RESTORER, "%s/%s: %s", o->job_path.s, name, folder_trouble(reason));
}

gsf_result gsfix_check_job(gsfix_app* app, const char* name) {
    const char* base;
    const int folder = open_folder(app->out->job, gsfix_pathf("%s/", name).s, 0, &base);
    const int reason = errno;
    if (folder >= 0) close(folder);
    if (folder >= 0 || reason == ENOENT) return GSF_OK;
    return gsf_fail(&app->ctx, GSF_ERROR_RESTORER, "%s/%s: %s", app->out->job_path.s, name, folder_trouble(reason));
}

void gsfix_leave_job(gsfix_app* app, int remove) {
    gsfix_out* o = app->out;
    struct stat s;
    if (o->job < 0) return;
    if (remove && remove_below(o->job, o->job_place.device) &&
        fstatat(o->root, o->job_name, &s, AT_SYMLINK_NOFOLLOW) == 0 && same_place(place_of(&s), o->job_place))
        unlinkat(o->root, o->job_name, AT_REMOVEDIR);
    close(o->job);
    o->job = -1;
}

// ---- begin and end ---------------------------------------------------------------

gsf_result gsfix_begin_files(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = (gsfix_out*)gsf_alloc_zeroed(ctx, 1, sizeof *o);
    if (!o) return GSF_ERROR_OUT_OF_MEMORY;
    o->root = o->own = o->lock = o->manifest = o->job = -1;
    o->existed = SIZE_MAX; // OUT has not been opened yet
    o->plain = ctx->io;
    app->out = o;
    ctx->io.read_fn = read_hook;
    ctx->io.write_fn = write_hook;
    ctx->io.user = app;
    ctx->io.plain_files = 1;
    return GSF_OK;
}

void gsfix_end_files(gsfix_app* app) {
    gsf_context* ctx = &app->ctx;
    gsfix_out* o = app->out;
    if (!o) return;
    gsfix_leave_job(app, 0);
    if (o->lock >= 0 && o->is_new && !o->line_count) { // a run that wrote nothing leaves no trace
        unlinkat(o->own, "manifest", 0);
        unlinkat(o->own, "lock", 0);
        unlinkat(o->root, ".gsfix", AT_REMOVEDIR);
    }
    const int open_ones[] = {o->manifest, o->own, o->root, o->lock};
    for (int i = 0; i < 4; i++)
        if (open_ones[i] >= 0) close(open_ones[i]);
    if (o->existed != SIZE_MAX) remove_made(o, app->o.out);
    ctx->io = o->plain;
    while (o->line_count) drop_line(ctx, o, o->line_count - 1);
    for (size_t i = 0; i < o->input_count; i++) gsf_free(ctx, o->inputs[i].path);
    for (size_t i = 0; i < o->read_count; i++) gsf_free(ctx, o->reads[i].path);
    for (size_t i = 0; i < o->claim_count; i++) gsf_free(ctx, o->claims[i]);
    for (size_t i = 0; i < o->file_count; i++) gsf_free(ctx, o->files[i]);
    void* const lists[] = {o->lines, o->inputs, o->reads, o->claims, o->files, o};
    for (size_t i = 0; i < sizeof lists / sizeof *lists; i++) gsf_free(ctx, lists[i]);
    app->out = NULL;
}
