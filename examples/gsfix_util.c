// gsfix_util.c - files, images, JSON and progress output for gsfix
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <time.h>
#include <unistd.h>
#ifdef _WIN32
#define GSFIX_W_NAMES
#include "gsfix_windows.h"
#else
#include <dirent.h>
#include <sys/resource.h>
#include <sys/stat.h>
#endif

// ---- time, memory, files ---------------------------------------------------------

double gsfix_now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

double gsfix_physical_memory(void) {
#if defined(_WIN32)
    return gsfix_w_memory(GSFIX_W_OF_MACHINE);
#elif defined(_SC_PHYS_PAGES)
    const long pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGESIZE);
    if (pages > 0 && size > 0) return (double)pages * (double)size;
    return 0.0;
#else
    return 0.0;
#endif
}

uint64_t gsfix_peak_memory(void) {
#ifdef _WIN32
    return (uint64_t)gsfix_w_memory(GSFIX_W_PEAK);
#else
    struct rusage usage;
    if (getrusage(RUSAGE_SELF, &usage) != 0) return 0;
#ifdef __APPLE__
    return (uint64_t)usage.ru_maxrss;
#else
    return (uint64_t)usage.ru_maxrss * 1024u;
#endif
#endif
}

double gsfix_anonymous_memory(void) {
    double bytes = 0.0;
#if defined(_WIN32)
    bytes = gsfix_w_memory(GSFIX_W_PRIVATE);
#elif defined(__linux__)
    unsigned long resident, shared;
    FILE* file = fopen("/proc/self/statm", "r");
    if (file && fscanf(file, "%*u %lu %lu", &resident, &shared) == 2)
        bytes = (double)(resident - shared) * (double)sysconf(_SC_PAGESIZE);
    if (file) fclose(file);
#endif
    return bytes;
}

gsfix_path gsfix_pathf(const char* format, ...) { // a path that is too long becomes empty, and is then not found
    gsfix_path path;
    va_list args;
    va_start(args, format);
    const int n = vsnprintf(path.s, sizeof path.s, format, args);
    va_end(args);
    if (n < 0 || (size_t)n >= sizeof path.s) path.s[0] = 0;
    return path;
}

int gsfix_exists(const char* path) {
    struct stat s;
    return stat(path, &s) == 0;
}

int gsfix_is_folder(const char* path) {
    struct stat s;
    return stat(path, &s) == 0 && S_ISDIR(s.st_mode);
}

uint64_t gsfix_file_size(const char* path) {
    struct stat s;
    return path && stat(path, &s) == 0 ? (uint64_t)s.st_size : 0;
}

gsf_result gsfix_make_folder(gsf_context* ctx, const char* path) {
    gsfix_path part = gsfix_pathf("%s", path);
    for (char* p = part.s + 1;; p++) {
        if (*p != '/' && *p != 0) continue;
        const char end = *p;
        *p = 0;
        const int reason = mkdir(part.s, 0777) == 0 ? 0 : errno;
        if (reason && !gsfix_is_folder(part.s)) // EEXIST may also mean a file or a dangling link
            return gsf_fail(ctx, GSF_ERROR_IO, "%s: folder cannot be made: %s", part.s, strerror(reason));
        *p = end;
        if (!end) return GSF_OK;
    }
}

char* gsfix_copy_text(gsf_context* ctx, const char* text, size_t size) {
    char* copy = (char*)gsf_alloc(ctx, size + 1, 1);
    if (!copy) return NULL;
    memcpy(copy, text, size);
    copy[size] = 0;
    return copy;
}

gsf_result gsfix_grow(gsf_context* ctx, void** list, size_t* room, size_t count, size_t size) {
    if (count < *room) return GSF_OK;
    const size_t more = 2 * *room + 16;
    void* fresh = gsf_alloc(ctx, more, size);
    if (!fresh) return GSF_ERROR_OUT_OF_MEMORY;
    if (count) memcpy(fresh, *list, count * size);
    gsf_free(ctx, *list);
    *list = fresh;
    *room = more;
    return GSF_OK;
}

static int compare_names(const void* a, const void* b) { return strcmp(*(char* const*)a, *(char* const*)b); }

static int has_extension(const char* name, const char* extensions) {
    const char* dot = strrchr(name, '.');
    if (!dot || strlen(dot) > 8) return 0;
    char lower[16];
    size_t n = 0;
    for (; dot[n]; n++) lower[n] = (char)tolower((unsigned char)dot[n]);
    lower[n] = 0;
    const char* at = strstr(extensions, lower);
    return n > 1 && at && (at[n] == 0 || at[n] == '.');
}

gsf_result gsfix_list(gsf_context* ctx, const char* path, const char* extensions, gsfix_names* out) {
    memset(out, 0, sizeof *out);
    DIR* folder = opendir(path);
    if (!folder) return gsf_fail(ctx, GSF_ERROR_IO, "%s: folder cannot be read: %s", path, strerror(errno));
    size_t room = 0;
    gsf_result result = GSF_OK;
    for (struct dirent* entry; (entry = readdir(folder)) != NULL;) {
        if (entry->d_name[0] == '.' || !has_extension(entry->d_name, extensions)) continue;
        if ((result = gsfix_grow(ctx, (void**)&out->names, &room, out->count, sizeof *out->names)) != GSF_OK) break;
        out->names[out->count] = gsfix_copy_text(ctx, entry->d_name, strlen(entry->d_name));
        if (!out->names[out->count]) { result = GSF_ERROR_OUT_OF_MEMORY; break; }
        out->count++;
    }
    closedir(folder);
    if (result != GSF_OK) gsfix_free_names(ctx, out);
    else if (out->count) qsort(out->names, out->count, sizeof *out->names, compare_names);
    return result;
}

void gsfix_free_names(gsf_context* ctx, gsfix_names* names) {
    for (size_t i = 0; i < names->count; i++) gsf_free(ctx, names->names[i]);
    gsf_free(ctx, names->names);
    memset(names, 0, sizeof *names);
}

gsfix_path gsfix_stem(const char* path) {
    const char* slash = strrchr(path, '/');
    gsfix_path stem = gsfix_pathf("%s", slash ? slash + 1 : path);
    char* dot = strrchr(stem.s, '.');
    if (dot && dot != stem.s) *dot = 0;
    return stem;
}

// Short form: no extension, folders joined by '_'. Full form: escaped, so that different names stay different.
static gsfix_path flat_name(const char* name, int is_short) {
    gsfix_path flat = {""};
    size_t n = 0;
    for (; *name && n + 4 < sizeof flat.s; name++) {
        const int is_slash = *name == '/' || *name == '\\';
        if (is_short || (!is_slash && *name != '%')) flat.s[n++] = is_slash ? '_' : *name;
        else n += (size_t)snprintf(flat.s + n, sizeof flat.s - n, "%%%02X", (unsigned)(unsigned char)*name);
    }
    char* dot = is_short ? strrchr(flat.s, '.') : NULL;
    if (dot && dot != flat.s) *dot = 0;
    return flat;
}

gsfix_path gsfix_view_stem(const gsf_scene* scene, size_t view) {
    const gsfix_path mine = flat_name(scene->views[view].name, 1);
    for (size_t i = 0; i < scene->view_count; i++) // a.jpg and a.png, a/b.png and a_b.png
        if (i != view && (strcmp(flat_name(scene->views[i].name, 1).s, mine.s) == 0 ||
                          strcmp(flat_name(scene->views[i].name, 0).s, mine.s) == 0))
            return flat_name(scene->views[view].name, 0);
    return mine;
}

/* .npy version 1: "\x93NUMPY" 1 0 | u16 size of the header text | header text | row-major float32. */
gsf_result gsfix_save_npy(gsf_context* ctx, const char* path, const gsf_image* image) {
    char header[118];
    const int used = snprintf(header, sizeof header, "{'descr': '<f4', 'fortran_order': False, 'shape': (%lld, %lld), }",
                              (long long)image->height, (long long)image->width);
    memset(header + used, ' ', sizeof header - (size_t)used);
    header[sizeof header - 1] = '\n';
    gsf_buffer text = {0};
    gsf_append_bytes(ctx, &text, "\x93NUMPY\x01\x00\x76\x00", 10); // 118 = 0x76: the data starts at byte 128
    gsf_append_bytes(ctx, &text, header, sizeof header);
    gsf_append_bytes(ctx, &text, (const char*)image->data,
                     (size_t)image->width * (size_t)image->height * sizeof(float));
    const gsf_result result = text.failed ? GSF_ERROR_OUT_OF_MEMORY : gsf_write_file(ctx, path, text.data, text.size);
    gsf_destroy_buffer(ctx, &text);
    return result;
}

gsf_result gsfix_load_npy(gsf_context* ctx, const char* path, gsf_image* out) {
    void* data;
    size_t size, begin = 0;
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_read_file(ctx, path, &data, &size);
    if (result != GSF_OK) return result;
    const unsigned char* p = (const unsigned char*)data;
    char header[1024] = "";
    if (size >= 12 && memcmp(p, "\x93NUMPY", 6) == 0 && (p[6] == 1 || p[6] == 2)) {
        const size_t fixed = p[6] == 1 ? 10 : 12;
        size_t text = p[8] | (size_t)p[9] << 8;
        if (p[6] == 2) text |= (size_t)p[10] << 16 | (size_t)p[11] << 24;
        if (text < sizeof header && size - fixed >= text) {
            memcpy(header, p + fixed, text);
            header[text] = 0;
            begin = fixed + text;
        }
    }
    const char* shape = strstr(header, "'shape': (");
    long long height = 0, width = 0;
    if (!begin || !strstr(header, "'descr': '<f4'") || !strstr(header, "'fortran_order': False") || !shape ||
        sscanf(shape + 10, "%lld, %lld", &height, &width) != 2 || height < 1 || width < 1)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT,
                          "%s: expected a .npy of little-endian float32, two dimensions, C order", path);
    else if ((size - begin) / 4 / (size_t)width < (size_t)height)
        result = gsf_fail(ctx, GSF_ERROR_FORMAT, "%s:%zu: %lld x %lld values do not fit into the file", path, begin, height,
                          width);
    else
        result = gsf_make_image(ctx, GSF_F32, width, height, 1, out);
    if (result == GSF_OK) memcpy(out->data, p + begin, (size_t)width * (size_t)height * sizeof(float));
    gsf_free(ctx, data);
    return result;
}

// ---- images ----------------------------------------------------------------------

static size_t value_count(const gsf_image* image) {
    return (size_t)image->width * (size_t)image->height * (size_t)image->channels;
}

typedef struct encode_job {
    const gsf_context* ctx;
    const gsf_image* images;
    gsf_buffer* files;
    gsf_result* results;
    char (*errors)[sizeof((gsf_context*)0)->error];
} encode_job;

static void encode_one(void* arg, size_t i, int32_t worker) {
    const encode_job* job = (const encode_job*)arg;
    gsf_context own = *job->ctx; // a context serves one thread; this copy starts no parallel work and does not log
    (void)worker;
    own.parallel.worker_count = 1;
    memset(&own.logger, 0, sizeof own.logger);
    own.error[0] = 0;
    job->results[i] = gsf_encode_image(&own, &job->images[i], ".png", &job->files[i]);
    memcpy(job->errors[i], own.error, sizeof own.error);
}

gsf_result gsfix_save_images(gsf_context* ctx, const gsfix_path* paths, const gsf_image* images, size_t count) {
    encode_job job = {ctx, images, NULL, NULL, NULL};
    gsf_result result = GSF_OK;
    if (!count) return GSF_OK;
    job.files = (gsf_buffer*)gsf_alloc_zeroed(ctx, count, sizeof *job.files);
    job.results = (gsf_result*)gsf_alloc_zeroed(ctx, count, sizeof *job.results);
    job.errors = gsf_alloc_zeroed(ctx, count, sizeof *job.errors);
    if (!job.files || !job.results || !job.errors) result = GSF_ERROR_OUT_OF_MEMORY;
    if (result == GSF_OK) ctx->parallel.for_fn(ctx->parallel.user, count, encode_one, &job);
    for (size_t i = 0; i < count && result == GSF_OK; i++)
        result = job.results[i] != GSF_OK ? gsf_fail(ctx, job.results[i], "%s: %s", paths[i].s, job.errors[i])
                                          : gsf_write_file(ctx, paths[i].s, job.files[i].data, job.files[i].size);
    for (size_t i = 0; job.files && i < count; i++) gsf_destroy_buffer(ctx, &job.files[i]);
    gsf_free(ctx, job.files);
    gsf_free(ctx, job.results);
    gsf_free(ctx, job.errors);
    return result;
}

void gsfix_clamp(gsf_image* image) {
    float* p = (float*)image->data;
    for (size_t i = 0; i < value_count(image); i++) p[i] = p[i] > 0.0f ? p[i] < 1.0f ? p[i] : 1.0f : 0.0f;
}

int gsfix_counts_any(const gsf_image* mask) {
    const uint8_t* p = (const uint8_t*)mask->data;
    for (size_t i = 0; i < (size_t)mask->width * (size_t)mask->height; i++)
        if (p[i]) return 1;
    return 0;
}

void gsfix_map_color(double t, uint8_t rgb[3]) { // matplotlib's inferno, as a polynomial (M. Zucker's fit, CC0)
    static const double c[3][7] = {
        {0.00021894, 0.10651342, 11.60249308, -41.70399613, 77.16293570, -71.31942824, 25.13112622},
        {0.00165100, 0.56395644, -3.97285397, 17.43639888, -33.40235894, 32.62606426, -12.24266895},
        {-0.01948090, 3.93271239, -15.94239411, 44.35414520, -81.80730926, 73.20951986, -23.07032500}};
    t = t > 0.0 ? t < 1.0 ? t : 1.0 : 0.0;
    for (int k = 0; k < 3; k++) {
        double v = 0.0;
        for (int i = 6; i >= 0; i--) v = v * t + c[k][i];
        rgb[k] = (uint8_t)(255.0 * (v > 0.0 ? v < 1.0 ? v : 1.0 : 0.0) + 0.5);
    }
}

gsf_result gsfix_color_map(gsf_context* ctx, const gsf_image* values, double low, double high, gsf_image* out) {
    const gsf_result result = gsf_make_image(ctx, GSF_U8, values->width, values->height, 3, out);
    if (result != GSF_OK) return result;
    const float* v = (const float*)values->data;
    const size_t count = (size_t)values->width * (size_t)values->height;
    for (size_t i = 0; i < count; i++)
        gsfix_map_color(((double)v[i] - low) / (high - low), (uint8_t*)out->data + 3 * i);
    return GSF_OK;
}

static int compare_floats(const void* a, const void* b) {
    const float x = *(const float*)a, y = *(const float*)b;
    return x < y ? -1 : x > y;
}

gsf_result gsfix_color_depth(gsf_context* ctx, const gsf_image* depth, gsf_image* out) {
    const size_t pixels = (size_t)depth->width * (size_t)depth->height;
    const float* z = (const float*)depth->data;
    float* inverse = (float*)gsf_alloc(ctx, pixels, sizeof *inverse);
    if (!inverse) return GSF_ERROR_OUT_OF_MEMORY;
    size_t count = 0;
    for (size_t i = 0; i < pixels; i++)
        if (z[i] > 0.0f) inverse[count++] = 1.0f / z[i];
    double low = 0.0, high = 1.0;
    if (count) {
        qsort(inverse, count, sizeof *inverse, compare_floats);
        low = inverse[count / 50];
        high = inverse[count - 1 - count / 50];
        if (!(high > low)) high = low + 1e-6;
    }
    gsf_free(ctx, inverse);
    const gsf_result result = gsf_make_image(ctx, GSF_U8, depth->width, depth->height, 3, out);
    if (result != GSF_OK) return result;
    for (size_t i = 0; i < pixels; i++) // from 0.08, so that far surfaces differ from no surface
        if (z[i] > 0.0f)
            gsfix_map_color(0.08 + 0.92 * (1.0 / (double)z[i] - low) / (high - low), (uint8_t*)out->data + 3 * i);
    return GSF_OK;
}

gsf_result gsfix_mean_abs_error(gsf_context* ctx, const gsf_image* a, const gsf_image* b, gsf_image* out) {
    gsf_image left, right = {0};
    memset(out, 0, sizeof *out);
    gsf_result result = gsf_make_image(ctx, GSF_F32, a->width, a->height, 3, &left);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, b->width, b->height, 3, &right);
    if (result == GSF_OK) result = gsf_make_image(ctx, GSF_F32, a->width, a->height, 1, out);
    if (result == GSF_OK) result = gsf_convert_image(ctx, a, &left);
    if (result == GSF_OK) result = gsf_convert_image(ctx, b, &right);
    if (result == GSF_OK) {
        const float *p = (const float*)left.data, *q = (const float*)right.data;
        const size_t pixels = (size_t)a->width * (size_t)a->height;
        for (size_t i = 0; i < pixels; i++)
            ((float*)out->data)[i] = (fabsf(p[3 * i] - q[3 * i]) + fabsf(p[3 * i + 1] - q[3 * i + 1]) +
                                      fabsf(p[3 * i + 2] - q[3 * i + 2])) / 3.0f;
    } else {
        gsf_destroy_image(ctx, out);
    }
    gsf_destroy_image(ctx, &left);
    gsf_destroy_image(ctx, &right);
    return result;
}

// ---- messages and progress -------------------------------------------------------

void gsfix_hide_bar(gsfix_app* app) {
    if (app->bar_shown) fputs("\r\033[K", stderr);
    app->bar_shown = 0;
}

static void print_time(double seconds, char text[32]) {
    const int s = (int)(seconds + 0.5);
    if (s < 3600) snprintf(text, 32, "%d:%02d", s / 60, s % 60);
    else snprintf(text, 32, "%d:%02d:%02d", s / 3600, s / 60 % 60, s % 60);
}

// A progress bar on a terminal, at most ten updates a second; elsewhere one line per tenth of the work.
void gsfix_progress(gsfix_app* app, double done, double total, const char* format, ...) {
    const double now = gsfix_now(), share = total > 0.0 ? done / total : 0.0;
    const int tenth = (int)(10.0 * share);
    if (app->terminal ? now - app->bar_time < 0.1 : tenth <= app->line_share) return;
    app->bar_time = now;
    app->line_share = tenth;
    char text[256], clock[32];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    print_time(now - app->started, clock);
    if (!app->terminal) {
        fprintf(stderr, "%3d %%  %s  %s\n", (int)(100.0 * share + 1e-9), clock, text);
        return;
    }
    enum { WIDTH = 28 };
    char bar[3 * WIDTH + 1] = "";
    const int filled = (int)(WIDTH * share + 0.5);
    for (int i = 0; i < WIDTH; i++) strcat(bar, i < filled ? "\xe2\x94\x81" : "\xc2\xb7");
    fprintf(stderr, "\r\033[K%s %3d %%  %s  %s", bar, (int)(100.0 * share + 1e-9), clock, text);
    fflush(stderr);
    app->bar_shown = 1;
}

void gsfix_note(gsfix_app* app, const char* format, ...) {
    gsfix_hide_bar(app);
    va_list args;
    va_start(args, format);
    vfprintf(stderr, format, args);
    va_end(args);
    fputc('\n', stderr);
}

void gsfix_print(gsfix_app* app, const char* format, ...) {
    if (app->o.json) return;
    gsfix_hide_bar(app);
    va_list args;
    va_start(args, format);
    vfprintf(stdout, format, args);
    va_end(args);
    fputc('\n', stdout);
}

int gsfix_misused(gsfix_app* app, const char* format, ...) {
    char text[512];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    gsfix_hide_bar(app);
    if (app->command) fprintf(stderr, "gsfix %s: %s (see gsfix %s --help)\n", app->command, text, app->command);
    else fprintf(stderr, "gsfix: %s (see gsfix --help)\n", text);
    return 2;
}

int gsfix_failed(gsfix_app* app) {
    gsfix_hide_bar(app);
    const char* text = app->ctx.error[0] ? app->ctx.error : "out of memory";
    fprintf(stderr, "gsfix %s: %s\n", app->command, text);
    if (app->o.json) {
        gsf_destroy_buffer(&app->ctx, &app->json);
        gsfix_json_begin(&app->ctx, &app->json, NULL, '{');
        gsfix_json_text(&app->ctx, &app->json, "error", text);
        gsfix_json_end(&app->ctx, &app->json, '}');
    }
    return 1;
}

// ---- JSON ------------------------------------------------------------------------

static void json_member(gsf_context* ctx, gsf_buffer* text, const char* key) {
    const char last = text->size ? text->data[text->size - 1] : '{';
    if (last != '{' && last != '[') gsf_append_bytes(ctx, text, ",", 1);
    if (!key) return;
    gsf_append_json_string(ctx, text, key);
    gsf_append_bytes(ctx, text, ":", 1);
}

void gsfix_json_begin(gsf_context* ctx, gsf_buffer* text, const char* key, char bracket) {
    json_member(ctx, text, key);
    gsf_append_bytes(ctx, text, &bracket, 1);
}

void gsfix_json_end(gsf_context* ctx, gsf_buffer* text, char bracket) { gsf_append_bytes(ctx, text, &bracket, 1); }

void gsfix_json_text(gsf_context* ctx, gsf_buffer* text, const char* key, const char* value) {
    json_member(ctx, text, key);
    if (value) gsf_append_json_string(ctx, text, value);
    else gsf_append_bytes(ctx, text, "null", 4);
}

void gsfix_json_number(gsf_context* ctx, gsf_buffer* text, const char* key, double value) {
    json_member(ctx, text, key);
    gsf_append_json_number(ctx, text, value);
}

void gsfix_json_bool(gsf_context* ctx, gsf_buffer* text, const char* key, int value) {
    json_member(ctx, text, key);
    gsf_append_bytes(ctx, text, value ? "true" : "false", value ? 4 : 5);
}
