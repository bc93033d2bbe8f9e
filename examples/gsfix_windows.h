// gsfix_windows.h - the part of POSIX that gsfix uses, for Windows: paths are UTF-8 and of any length
// SPDX-License-Identifier: MIT
#ifndef GSFIX_WINDOWS_H
#define GSFIX_WINDOWS_H

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/stat.h> // S_ISREG and so on
#include <sys/types.h>
#include <time.h>

/* Descriptors are those of gsfix_windows.c, not of the C runtime. A folder's descriptor holds an open handle, and names below
   it are looked up under the path that the handle had when it was opened, so that links on the way are followed once only.
   Open files and folders may be renamed and removed by others, as on POSIX. On failure the functions return -1 or NULL and set
   errno. */

struct gsfix_w_stat {
    uint64_t st_dev, st_ino, st_size;
    unsigned st_mode;
    struct timespec st_ctim; // last change of contents, name or attributes
};
struct gsfix_w_dirent { char d_name[3 * 260]; }; // a unit of UTF-16 takes up to three bytes
typedef struct gsfix_w_dir gsfix_w_dir;

enum {
    GSFIX_W_RDONLY = 0, GSFIX_W_WRONLY = 1, GSFIX_W_RDWR = 2, GSFIX_W_CREAT = 4, GSFIX_W_EXCL = 8, GSFIX_W_APPEND = 16,
    GSFIX_W_DIRECTORY = 32, GSFIX_W_NOFOLLOW = 64
};

int gsfix_w_open(const char* path, int flags, ...);
int gsfix_w_openat(int folder, const char* name, int flags, ...);
int gsfix_w_dup(int file);
int gsfix_w_close(int file);
ptrdiff_t gsfix_w_read(int file, void* data, size_t size);
ptrdiff_t gsfix_w_write(int file, const void* data, size_t size);
int gsfix_w_fsync(int file);
int gsfix_w_ftruncate(int file, int64_t size);
int gsfix_w_lock(int file); // exclusively, or EWOULDBLOCK; ends with the process
int gsfix_w_stat(const char* path, struct gsfix_w_stat* out);
int gsfix_w_lstat(const char* path, struct gsfix_w_stat* out);
int gsfix_w_fstat(int file, struct gsfix_w_stat* out);
int gsfix_w_fstatat(int folder, const char* name, struct gsfix_w_stat* out, int flags); // never of a link's target
int gsfix_w_mkdir(const char* path);
int gsfix_w_mkdirat(int folder, const char* name);
int gsfix_w_rmdir(const char* path);
int gsfix_w_unlinkat(int folder, const char* name, int is_folder);
int gsfix_w_renameat(int from_folder, const char* from, int to_folder, const char* to); // replaces a file
int gsfix_w_linkat(int from_folder, const char* from, int to_folder, const char* to);
int gsfix_w_check_writable(int folder);
char* gsfix_w_realpath(const char* path); // with slashes; freed by the caller
gsfix_w_dir* gsfix_w_opendir(const char* path);
gsfix_w_dir* gsfix_w_fdopendir(int folder); // takes the descriptor
struct gsfix_w_dirent* gsfix_w_readdir(gsfix_w_dir* dir);
void gsfix_w_closedir(gsfix_w_dir* dir);
FILE* gsfix_w_fopen(const char* path); // for reading

// The program's arguments as UTF-8, with slashes in paths; they live until it ends. Sets the console up for UTF-8. NULL: out
// of memory.
char** gsfix_w_arguments(int* count);
int gsfix_w_is_terminal(void); // stderr is a console that understands escape sequences

typedef enum gsfix_w_memory_kind { GSFIX_W_OF_MACHINE, GSFIX_W_PEAK, GSFIX_W_PRIVATE } gsfix_w_memory_kind;
double gsfix_w_memory(gsfix_w_memory_kind kind); // bytes; PEAK, PRIVATE: of this process

#endif

#ifdef GSFIX_W_NAMES // the names that the rest of gsfix uses
#undef O_RDONLY
#undef O_WRONLY
#undef O_RDWR
#undef O_CREAT
#undef O_EXCL
#undef O_APPEND
#define O_RDONLY GSFIX_W_RDONLY
#define O_WRONLY GSFIX_W_WRONLY
#define O_RDWR GSFIX_W_RDWR
#define O_CREAT GSFIX_W_CREAT
#define O_EXCL GSFIX_W_EXCL
#define O_APPEND GSFIX_W_APPEND
#define O_DIRECTORY GSFIX_W_DIRECTORY
#define O_NOFOLLOW GSFIX_W_NOFOLLOW
#define O_NONBLOCK 0
#define O_CLOEXEC 0
#define AT_SYMLINK_NOFOLLOW 0
#define AT_REMOVEDIR 1
#define stat gsfix_w_stat
#define dirent gsfix_w_dirent
#define DIR gsfix_w_dir
#define dev_t uint64_t
#define ino_t uint64_t
#define ssize_t ptrdiff_t
#define open gsfix_w_open
#define openat gsfix_w_openat
#define close gsfix_w_close
#define read gsfix_w_read
#define write gsfix_w_write
#define fsync gsfix_w_fsync
#define ftruncate gsfix_w_ftruncate
#define lstat gsfix_w_lstat
#define fstat gsfix_w_fstat
#define fstatat gsfix_w_fstatat
#define rmdir gsfix_w_rmdir
#define unlinkat gsfix_w_unlinkat
#define renameat gsfix_w_renameat
#define opendir gsfix_w_opendir
#define fdopendir gsfix_w_fdopendir
#define readdir gsfix_w_readdir
#define closedir gsfix_w_closedir
#define mkdir(path, mode) gsfix_w_mkdir(path)
#define mkdirat(folder, name, mode) gsfix_w_mkdirat(folder, name)
#define linkat(from, name, to, link, flags) gsfix_w_linkat(from, name, to, link)
#define faccessat(folder, name, mode, flags) gsfix_w_check_writable(folder)
#undef realpath
#define realpath(path, room) gsfix_w_realpath(path)
#define flock(file, how) gsfix_w_lock(file)
#endif
