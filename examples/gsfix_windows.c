// gsfix_windows.c - the part of POSIX that gsfix uses, for Windows; empty elsewhere
// SPDX-License-Identifier: MIT
#include "gsfix.h"

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#define NOMINMAX
#include <windows.h>
#include <errno.h>
#include <fcntl.h>
#include <io.h>
#include <psapi.h>
#include <shellapi.h>
#include "gsfix_windows.h"

enum { W_FILES = 256, W_SHARE = FILE_SHARE_READ | FILE_SHARE_WRITE | FILE_SHARE_DELETE };

typedef struct w_file {
    HANDLE handle;
    wchar_t* path; // of a folder: the form \\?\ without a final backslash
    int appends;
} w_file;

static w_file w_files[W_FILES];

static int w_fail(DWORD reason) {
    switch (reason) {
        case ERROR_FILE_NOT_FOUND:
        case ERROR_PATH_NOT_FOUND:
        case ERROR_INVALID_NAME:
        case ERROR_BAD_NETPATH: errno = ENOENT; break;
        case ERROR_SHARING_VIOLATION:
        case ERROR_ACCESS_DENIED: errno = EACCES; break;
        case ERROR_LOCK_VIOLATION:
        case ERROR_IO_PENDING: errno = EWOULDBLOCK; break;
        case ERROR_ALREADY_EXISTS:
        case ERROR_FILE_EXISTS: errno = EEXIST; break;
        case ERROR_DIR_NOT_EMPTY: errno = ENOTEMPTY; break;
        case ERROR_DIRECTORY: errno = ENOTDIR; break;
        case ERROR_FILENAME_EXCED_RANGE: errno = ENAMETOOLONG; break;
        case ERROR_DISK_FULL:
        case ERROR_HANDLE_DISK_FULL: errno = ENOSPC; break;
        case ERROR_NOT_ENOUGH_MEMORY: errno = ENOMEM; break;
        default: errno = EIO;
    }
    return -1;
}

// ---- names -----------------------------------------------------------------------

static wchar_t* w_wide(const char* text) { // NULL: not UTF-8, or out of memory
    const int size = MultiByteToWideChar(CP_UTF8, MB_ERR_INVALID_CHARS, text, -1, NULL, 0);
    wchar_t* wide = size > 0 ? (wchar_t*)malloc((size_t)size * sizeof *wide) : NULL;
    errno = size > 0 ? ENOMEM : ENOENT;
    if (wide) MultiByteToWideChar(CP_UTF8, 0, text, -1, wide, size);
    return wide;
}

static char* w_narrow(const wchar_t* text) {
    const int size = WideCharToMultiByte(CP_UTF8, 0, text, -1, NULL, 0, NULL, NULL);
    char* narrow = size > 0 ? (char*)malloc((size_t)size) : NULL;
    if (narrow) WideCharToMultiByte(CP_UTF8, 0, text, -1, narrow, size, NULL, NULL);
    return narrow;
}

// The whole path in the form \\?\, in which names may be long and mean what they say. Devices (NUL) keep their form \\.\.
static wchar_t* w_path(const char* path) {
    wchar_t* wide = w_wide(path);
    if (!wide) return NULL;
    const DWORD room = GetFullPathNameW(wide, 0, NULL, NULL);
    wchar_t* whole = room ? (wchar_t*)malloc(((size_t)room + 8) * sizeof *whole) : NULL; // 8: of the longest prefix
    const DWORD used = whole ? GetFullPathNameW(wide, room, whole + 8, NULL) : 0;
    free(wide);
    if (!used || used >= room) {
        free(whole);
        w_fail(GetLastError());
        return NULL;
    }
    const wchar_t* full = whole + 8;
    const int marked = wcsncmp(full, L"\\\\?\\", 4) == 0 || wcsncmp(full, L"\\\\.\\", 4) == 0;
    const int network = !marked && full[0] == L'\\' && full[1] == L'\\'; // \\server\share becomes \\?\UNC\server\share
    const size_t length = marked ? 0 : network ? 7 : 4;
    memmove(whole + length, full + network, ((size_t)used + 1 - (size_t)network) * sizeof *whole);
    memcpy(whole, network ? L"\\\\?\\UNC" : L"\\\\?\\", length * sizeof *whole);
    size_t end = wcslen(whole);
    if (end > 7 && whole[end - 1] == L'\\' && whole[end - 2] != L':') whole[end - 1] = 0;
    return whole;
}

static w_file* w_find(int file) {
    errno = EBADF;
    return file >= 0 && file < W_FILES && w_files[file].handle ? &w_files[file] : NULL;
}

static wchar_t* w_path_at(int folder, const char* name) {
    const w_file* at = w_find(folder);
    if (!at || !at->path) return NULL;
    wchar_t* wide = w_wide(name);
    if (!wide) return NULL;
    const size_t before = wcslen(at->path), size = wcslen(wide);
    wchar_t* whole = (wchar_t*)malloc((before + size + 2) * sizeof *whole);
    if (whole) {
        memcpy(whole, at->path, before * sizeof *whole);
        whole[before] = L'\\';
        memcpy(whole + before + 1, wide, (size + 1) * sizeof *whole);
        if (strcmp(name, ".") == 0) whole[before] = 0; // the form \\?\ takes names literally
    }
    errno = ENOMEM;
    free(wide);
    return whole;
}

static wchar_t* w_final_path(HANDLE handle) { // in the form \\?\ without a final backslash
    const DWORD room = GetFinalPathNameByHandleW(handle, NULL, 0, FILE_NAME_NORMALIZED | VOLUME_NAME_DOS);
    wchar_t* path = room ? (wchar_t*)malloc(((size_t)room + 1) * sizeof *path) : NULL;
    if (!path) return NULL;
    const DWORD used = GetFinalPathNameByHandleW(handle, path, room + 1, 0);
    path[used <= room ? used : 0] = 0;
    if (used && path[used - 1] == L'\\') path[used - 1] = 0;
    return path;
}

// ---- descriptors -----------------------------------------------------------------

static wchar_t* w_copy(const wchar_t* text) {
    const size_t bytes = (wcslen(text) + 1) * sizeof *text;
    wchar_t* copy = (wchar_t*)malloc(bytes);
    if (copy) memcpy(copy, text, bytes);
    return copy;
}

// opened: the path of a folder, which counts if the system cannot tell where links have led to (Wine, of long ones).
static int w_keep(HANDLE handle, const wchar_t* opened, int flags) {
    wchar_t* path = flags & GSFIX_W_DIRECTORY ? w_final_path(handle) : NULL;
    if (!path && (flags & GSFIX_W_DIRECTORY)) path = w_copy(opened);
    for (int i = 0; i < W_FILES && (path || !(flags & GSFIX_W_DIRECTORY)); i++) {
        if (w_files[i].handle) continue;
        const w_file fresh = {handle, path, flags & GSFIX_W_APPEND};
        w_files[i] = fresh;
        return i;
    }
    CloseHandle(handle);
    free(path);
    errno = path ? EMFILE : ENOMEM;
    return -1;
}

static HANDLE w_create(const wchar_t* path, DWORD access, DWORD how, DWORD flags) {
    HANDLE handle = INVALID_HANDLE_VALUE;
    for (int attempt = 0; handle == INVALID_HANDLE_VALUE && attempt < 40; attempt++) { // others may hold it for a moment
        if (attempt) Sleep(attempt < 8 ? 2 : 30);
        handle = CreateFileW(path, access, W_SHARE, NULL, how, flags, NULL);
        if (handle == INVALID_HANDLE_VALUE && GetLastError() != ERROR_SHARING_VIOLATION) break;
    }
    return handle;
}

static int w_is_link(HANDLE handle) { // a symbolic link or a junction
    FILE_ATTRIBUTE_TAG_INFO info;
    return GetFileInformationByHandleEx(handle, FileAttributeTagInfo, &info, sizeof info) &&
           (info.FileAttributes & FILE_ATTRIBUTE_REPARSE_POINT) && (info.ReparseTag & 0x20000000);
}

static int w_open_path(wchar_t* path, int flags) { // frees path
    if (!path) return -1;
    const int is_folder = (flags & GSFIX_W_DIRECTORY) != 0;
    const int mode = flags & (GSFIX_W_WRONLY | GSFIX_W_RDWR);
    const DWORD access = is_folder ? FILE_LIST_DIRECTORY : mode == GSFIX_W_WRONLY ? GENERIC_WRITE :
                         mode == GSFIX_W_RDWR ? GENERIC_READ | GENERIC_WRITE : GENERIC_READ;
    const DWORD how = flags & GSFIX_W_EXCL ? CREATE_NEW : flags & GSFIX_W_CREAT ? OPEN_ALWAYS : OPEN_EXISTING;
    const DWORD links = flags & GSFIX_W_NOFOLLOW ? FILE_FLAG_OPEN_REPARSE_POINT : 0;
    HANDLE handle = w_create(path, access, how, links | (is_folder ? FILE_FLAG_BACKUP_SEMANTICS : FILE_ATTRIBUTE_NORMAL));
    if (handle == INVALID_HANDLE_VALUE) {
        w_fail(GetLastError());
        free(path);
        return -1;
    }
    BY_HANDLE_FILE_INFORMATION info;
    const int known = GetFileInformationByHandle(handle, &info) != 0;
    const int wrong = is_folder && (!known || !(info.dwFileAttributes & FILE_ATTRIBUTE_DIRECTORY));
    const int link = links && w_is_link(handle);
    const int file = wrong || link ? -1 : w_keep(handle, path, flags);
    free(path);
    if (!wrong && !link) return file;
    CloseHandle(handle);
    errno = link ? ELOOP : ENOTDIR;
    return -1;
}

int gsfix_w_open(const char* path, int flags, ...) { return w_open_path(w_path(path), flags); }
int gsfix_w_openat(int folder, const char* name, int flags, ...) { return w_open_path(w_path_at(folder, name), flags); }

int gsfix_w_dup(int file) { // of a folder
    const w_file* from = w_find(file);
    HANDLE handle, process = GetCurrentProcess();
    if (!from) return -1;
    if (!DuplicateHandle(process, from->handle, process, &handle, 0, FALSE, DUPLICATE_SAME_ACCESS))
        return w_fail(GetLastError());
    return w_keep(handle, from->path, from->path ? GSFIX_W_DIRECTORY : 0);
}

int gsfix_w_close(int file) {
    w_file* f = w_find(file);
    if (!f) return -1;
    const int ok = CloseHandle(f->handle) != 0;
    free(f->path);
    memset(f, 0, sizeof *f);
    return ok ? 0 : w_fail(GetLastError());
}

ptrdiff_t gsfix_w_read(int file, void* data, size_t size) {
    const w_file* f = w_find(file);
    DWORD got = 0;
    if (!f) return -1;
    if (ReadFile(f->handle, data, size < 1 << 30 ? (DWORD)size : 1 << 30, &got, NULL)) return (ptrdiff_t)got;
    return GetLastError() == ERROR_HANDLE_EOF || GetLastError() == ERROR_BROKEN_PIPE ? 0 : w_fail(GetLastError());
}

ptrdiff_t gsfix_w_write(int file, const void* data, size_t size) {
    const w_file* f = w_find(file);
    const LARGE_INTEGER zero = {{0, 0}};
    DWORD done = 0;
    if (!f) return -1;
    if (f->appends && !SetFilePointerEx(f->handle, zero, NULL, FILE_END)) return w_fail(GetLastError());
    if (WriteFile(f->handle, data, size < 1 << 30 ? (DWORD)size : 1 << 30, &done, NULL)) return (ptrdiff_t)done;
    return w_fail(GetLastError());
}

int gsfix_w_fsync(int file) {
    const w_file* f = w_find(file);
    return !f ? -1 : FlushFileBuffers(f->handle) ? 0 : w_fail(GetLastError());
}

int gsfix_w_ftruncate(int file, int64_t size) {
    const w_file* f = w_find(file);
    LARGE_INTEGER end;
    end.QuadPart = size;
    if (!f) return -1;
    return SetFilePointerEx(f->handle, end, NULL, FILE_BEGIN) && SetEndOfFile(f->handle) ? 0 : w_fail(GetLastError());
}

int gsfix_w_lock(int file) { // a byte far beyond the end, so that nobody is kept from reading
    const w_file* f = w_find(file);
    OVERLAPPED at;
    memset(&at, 0, sizeof at);
    at.OffsetHigh = 0x40000000;
    if (!f) return -1;
    return LockFileEx(f->handle, LOCKFILE_EXCLUSIVE_LOCK | LOCKFILE_FAIL_IMMEDIATELY, 0, 1, 0, &at) ? 0
                                                                                                     : w_fail(GetLastError());
}

// ---- looking at files --------------------------------------------------------------

static int w_stat_handle(HANDLE handle, struct gsfix_w_stat* out) {
    BY_HANDLE_FILE_INFORMATION info;
    FILE_BASIC_INFO times;
    const DWORD type = GetFileType(handle);
    memset(out, 0, sizeof *out);
    if (type != FILE_TYPE_DISK) {
        out->st_mode = type == FILE_TYPE_PIPE ? S_IFIFO : S_IFCHR;
        return 0;
    }
    if (!GetFileInformationByHandle(handle, &info)) return w_fail(GetLastError());
    out->st_dev = info.dwVolumeSerialNumber;
    out->st_ino = (uint64_t)info.nFileIndexHigh << 32 | info.nFileIndexLow;
    out->st_size = (uint64_t)info.nFileSizeHigh << 32 | info.nFileSizeLow;
    out->st_mode = w_is_link(handle) ? 0xa000 : info.dwFileAttributes & FILE_ATTRIBUTE_DIRECTORY ? S_IFDIR : S_IFREG;
    if (GetFileInformationByHandleEx(handle, FileBasicInfo, &times, sizeof times)) { // units of 100 ns
        out->st_ctim.tv_sec = (time_t)(times.ChangeTime.QuadPart / 10000000);
        out->st_ctim.tv_nsec = (long)(times.ChangeTime.QuadPart % 10000000) * 100;
    }
    return 0;
}

static int w_stat_path(wchar_t* path, struct gsfix_w_stat* out, DWORD links) { // frees path
    if (!path) return -1;
    HANDLE handle = w_create(path, FILE_READ_ATTRIBUTES, OPEN_EXISTING, FILE_FLAG_BACKUP_SEMANTICS | links);
    const DWORD reason = GetLastError();
    free(path);
    if (handle == INVALID_HANDLE_VALUE) return w_fail(reason);
    const int result = w_stat_handle(handle, out);
    CloseHandle(handle);
    return result;
}

int gsfix_w_stat(const char* path, struct gsfix_w_stat* out) { return w_stat_path(w_path(path), out, 0); }
int gsfix_w_lstat(const char* path, struct gsfix_w_stat* out) {
    return w_stat_path(w_path(path), out, FILE_FLAG_OPEN_REPARSE_POINT);
}
int gsfix_w_fstat(int file, struct gsfix_w_stat* out) {
    const w_file* f = w_find(file);
    return f ? w_stat_handle(f->handle, out) : -1;
}
int gsfix_w_fstatat(int folder, const char* name, struct gsfix_w_stat* out, int flags) {
    (void)flags;
    return w_stat_path(w_path_at(folder, name), out, FILE_FLAG_OPEN_REPARSE_POINT);
}

char* gsfix_w_realpath(const char* path) {
    wchar_t* wide = w_path(path);
    if (!wide) return NULL;
    HANDLE handle = w_create(wide, FILE_READ_ATTRIBUTES, OPEN_EXISTING, FILE_FLAG_BACKUP_SEMANTICS);
    const DWORD reason = GetLastError();
    free(wide);
    if (handle == INVALID_HANDLE_VALUE) {
        w_fail(reason);
        return NULL;
    }
    wchar_t* final = w_final_path(handle);
    CloseHandle(handle);
    if (!final) return NULL;
    const int network = wcsncmp(final, L"\\\\?\\UNC\\", 8) == 0, marked = wcsncmp(final, L"\\\\?\\", 4) == 0;
    if (network) final[6] = L'\\'; // \\server\share
    char* narrow = w_narrow(final + (network ? 6 : marked ? 4 : 0));
    free(final);
    for (char* c = narrow; c && *c; c++)
        if (*c == '\\') *c = '/';
    return narrow;
}

FILE* gsfix_w_fopen(const char* path) {
    wchar_t* wide = w_path(path);
    if (!wide) return NULL;
    HANDLE handle = w_create(wide, GENERIC_READ, OPEN_EXISTING, FILE_ATTRIBUTE_NORMAL);
    const DWORD reason = GetLastError();
    free(wide);
    if (handle == INVALID_HANDLE_VALUE) {
        w_fail(reason);
        return NULL;
    }
    const int file = _open_osfhandle((intptr_t)handle, _O_RDONLY | _O_BINARY);
    return file < 0 ? NULL : _fdopen(file, "rb");
}

// ---- changing folders --------------------------------------------------------------

static int w_end(wchar_t* path, int ok) { // frees path
    const DWORD reason = GetLastError();
    free(path);
    return ok ? 0 : w_fail(reason);
}

static int w_make_folder(wchar_t* path) { return path ? w_end(path, CreateDirectoryW(path, NULL) != 0) : -1; }
int gsfix_w_mkdir(const char* path) { return w_make_folder(w_path(path)); }
int gsfix_w_mkdirat(int folder, const char* name) { return w_make_folder(w_path_at(folder, name)); }

int gsfix_w_rmdir(const char* path) {
    wchar_t* wide = w_path(path);
    return wide ? w_end(wide, RemoveDirectoryW(wide) != 0) : -1;
}

int gsfix_w_unlinkat(int folder, const char* name, int is_folder) {
    wchar_t* path = w_path_at(folder, name);
    if (!path) return -1;
    const DWORD attributes = GetFileAttributesW(path);
    const int below = attributes != INVALID_FILE_ATTRIBUTES && (attributes & FILE_ATTRIBUTE_DIRECTORY); // or a link to one
    int ok = is_folder || below ? RemoveDirectoryW(path) : DeleteFileW(path);
    return w_end(path, ok);
}

int gsfix_w_renameat(int from_folder, const char* from, int to_folder, const char* to) {
    wchar_t *source = w_path_at(from_folder, from), *target = w_path_at(to_folder, to);
    int ok = 0;
    for (int attempt = 0; source && target && !ok && attempt < 40; attempt++) { // readers may hold the old file for a moment
        if (attempt) Sleep(attempt < 8 ? 2 : 30);
        ok = MoveFileExW(source, target, MOVEFILE_REPLACE_EXISTING | MOVEFILE_WRITE_THROUGH) != 0;
        const DWORD reason = GetLastError();
        if (!ok) w_fail(reason);
        if (!ok && reason != ERROR_SHARING_VIOLATION && reason != ERROR_ACCESS_DENIED) break;
    }
    const int reason = errno;
    free(source);
    free(target);
    errno = reason;
    return ok ? 0 : -1;
}

int gsfix_w_linkat(int from_folder, const char* from, int to_folder, const char* to) {
    wchar_t *source = w_path_at(from_folder, from), *target = w_path_at(to_folder, to);
    const int ok = source && target && CreateHardLinkW(target, source, NULL);
    const DWORD reason = GetLastError();
    free(source);
    free(target);
    return ok ? 0 : w_fail(reason);
}

int gsfix_w_check_writable(int folder) {
    const w_file* f = w_find(folder);
    if (!f || !f->path) return -1;
    HANDLE handle = w_create(f->path, FILE_ADD_FILE | FILE_ADD_SUBDIRECTORY, OPEN_EXISTING, FILE_FLAG_BACKUP_SEMANTICS);
    if (handle == INVALID_HANDLE_VALUE) return w_fail(GetLastError());
    CloseHandle(handle);
    return 0;
}

// ---- listing folders ---------------------------------------------------------------

struct gsfix_w_dir {
    HANDLE search;
    WIN32_FIND_DATAW next;
    int has_next;
    struct gsfix_w_dirent entry;
};

static gsfix_w_dir* w_list(const wchar_t* folder) {
    const size_t size = wcslen(folder);
    wchar_t* pattern = (wchar_t*)malloc((size + 3) * sizeof *pattern);
    gsfix_w_dir* dir = (gsfix_w_dir*)calloc(1, sizeof *dir);
    errno = ENOMEM;
    if (pattern && dir) {
        memcpy(pattern, folder, size * sizeof *pattern);
        memcpy(pattern + size, L"\\*", 3 * sizeof *pattern);
        dir->search = FindFirstFileW(pattern, &dir->next);
        dir->has_next = dir->search != INVALID_HANDLE_VALUE;
        if (!dir->has_next) w_fail(GetLastError());
    }
    const int reason = errno;
    free(pattern);
    if (dir && dir->has_next) return dir;
    free(dir);
    errno = reason;
    return NULL;
}

gsfix_w_dir* gsfix_w_opendir(const char* path) {
    wchar_t* wide = w_path(path);
    gsfix_w_dir* dir = wide ? w_list(wide) : NULL;
    const int reason = errno;
    free(wide);
    errno = reason;
    return dir;
}

gsfix_w_dir* gsfix_w_fdopendir(int folder) {
    const w_file* f = w_find(folder);
    gsfix_w_dir* dir = f && f->path ? w_list(f->path) : NULL;
    if (dir) gsfix_w_close(folder);
    return dir;
}

struct gsfix_w_dirent* gsfix_w_readdir(gsfix_w_dir* dir) {
    int ok = 0;
    while (dir->has_next && !ok) { // a name that is not Unicode cannot be passed on, and is left out
        ok = WideCharToMultiByte(CP_UTF8, WC_ERR_INVALID_CHARS, dir->next.cFileName, -1, dir->entry.d_name,
                                 sizeof dir->entry.d_name, NULL, NULL) > 0;
        dir->has_next = FindNextFileW(dir->search, &dir->next) != 0;
    }
    return ok ? &dir->entry : NULL;
}

void gsfix_w_closedir(gsfix_w_dir* dir) {
    FindClose(dir->search);
    free(dir);
}

// ---- the process -------------------------------------------------------------------

char** gsfix_w_arguments(int* count) {
    wchar_t** wide = CommandLineToArgvW(GetCommandLineW(), count);
    char** narrow = wide ? (char**)calloc((size_t)*count + 1, sizeof *narrow) : NULL;
    for (int i = 0; narrow && i < *count; i++) {
        narrow[i] = w_narrow(wide[i]);
        if (!narrow[i]) return NULL;
        const int is_text = i && (strcmp(narrow[i - 1], "--prompt") == 0 || strcmp(narrow[i - 1], "--caption") == 0);
        if (is_text || strncmp(narrow[i], "exec:", 5) == 0 || strncmp(narrow[i], "\\\\", 2) == 0) continue;
        for (char* c = narrow[i]; *c; c++)
            if (*c == '\\') *c = '/';
    }
    LocalFree(wide);
    SetConsoleOutputCP(CP_UTF8);
    _setmode(1, _O_BINARY); // the same bytes as elsewhere
    return narrow;
}

int gsfix_w_is_terminal(void) {
    HANDLE console = GetStdHandle(STD_ERROR_HANDLE);
    DWORD mode;
    return GetConsoleMode(console, &mode) && SetConsoleMode(console, mode | ENABLE_VIRTUAL_TERMINAL_PROCESSING);
}

double gsfix_w_memory(gsfix_w_memory_kind kind) {
    MEMORYSTATUSEX machine;
    PROCESS_MEMORY_COUNTERS_EX process;
    memset(&machine, 0, sizeof machine);
    memset(&process, 0, sizeof process);
    machine.dwLength = sizeof machine;
    process.cb = sizeof process;
    if (kind == GSFIX_W_OF_MACHINE) return GlobalMemoryStatusEx(&machine) ? (double)machine.ullTotalPhys : 0.0;
    if (!K32GetProcessMemoryInfo(GetCurrentProcess(), (PROCESS_MEMORY_COUNTERS*)&process, sizeof process)) return 0.0;
    return kind == GSFIX_W_PEAK ? (double)process.PeakWorkingSetSize : (double)process.PrivateUsage;
}
#endif
