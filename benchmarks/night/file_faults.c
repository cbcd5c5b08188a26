/* Breaks the n-th file operation below some folders, for tests; to be preloaded (LD_PRELOAD).

   BREAK_BELOW names the folders, with ":" between them. Nothing happens until break_at() is called, which a process
   that forks does in its child. Counted are open for writing, write, fsync, rename, unlink, mkdir and rmdir.

   KILL   the process is killed instead of the operation
   TORN   a write puts half of its bytes down, then the process is killed; other operations as KILL
   POWER  as KILL, and files lose what was written to them since they were synced
   EIO    the operation fails once with EIO
   ENOSPC it fails with ENOSPC, and so does each one after it that needs room
*/
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { NEVER, KILL, TORN, POWER, FAIL_ONCE, DISK_FULL };
enum { FILES = 64 };

static int mode, full;
static long left, count;
static char unsynced[FILES][PATH_MAX]; /* files that were written since they were synced */
static off_t safe[FILES];              /* how long they were before that */

#define REAL(name) \
    static __typeof__(name) *real; \
    if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)

void break_at(long n, int how) { left = n; mode = how; count = 0; full = 0; }
long broken_count(void) { return count; }

static int watched(const char *path) {
    const char *folders = getenv("BREAK_BELOW");
    while (folders && *folders) {
        size_t length = strcspn(folders, ":");
        if (length && !strncmp(path, folders, length)) return 1;
        folders += length + (folders[length] == ':');
    }
    return 0;
}

static const char *of_descriptor(int fd, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, PATH_MAX - 1);
    if (n < 0) n = 0;
    path[n] = 0;
    return path;
}

static const char *absolute(int folder, const char *path, char *whole) {
    if (path[0] == '/') return path;
    if (folder == AT_FDCWD) { if (!getcwd(whole, PATH_MAX)) whole[0] = 0; }
    else of_descriptor(folder, whole);
    size_t n = strlen(whole);
    snprintf(whole + n, PATH_MAX - n, "/%s", path);
    return whole;
}

static void mark(const char *path, int dirty) {
    struct stat now;
    int room = -1;
    for (int i = 0; i < FILES; i++) {
        if (!strcmp(unsynced[i], path)) { if (!dirty) unsynced[i][0] = 0; return; }
        if (room < 0 && !unsynced[i][0]) room = i;
    }
    if (!dirty || room < 0) return;
    snprintf(unsynced[room], PATH_MAX, "%s", path);
    safe[room] = stat(path, &now) ? 0 : now.st_size;
}

static void moved(const char *from, const char *to) {
    for (int i = 0; i < FILES; i++) if (!strcmp(unsynced[i], from)) snprintf(unsynced[i], PATH_MAX, "%s", to);
}

static void die(void) {
    if (mode == POWER)
        for (int i = 0; i < FILES; i++) if (unsynced[i][0]) (void)!truncate(unsynced[i], safe[i]);
    raise(SIGKILL);
}

/* Return whether this operation fails, with errno set; a process that is to be killed does not return. */
static int breaks(const char *path, int needs_room, int is_write) {
    if (!mode || !watched(path)) return 0;
    count++;
    if (mode == DISK_FULL && full && needs_room) { errno = ENOSPC; return 1; }
    if (count != left) return 0;
    if (mode == TORN && is_write) return 2;
    if (mode == KILL || mode == TORN || mode == POWER) die();
    if (mode == DISK_FULL) { full = 1; if (!needs_room) return 0; }
    errno = mode == DISK_FULL ? ENOSPC : EIO;
    return 1;
}

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    char path[PATH_MAX];
    if (!mode || !watched(of_descriptor(fd, path))) return real(fd, data, size);
    int how = breaks(path, 1, 1);
    if (how == 1) return -1;
    if (how == 2) { (void)!real(fd, data, size / 2); raise(SIGKILL); }
    mark(path, 1);
    return real(fd, data, size);
}

int fsync(int fd) {
    REAL(fsync);
    char path[PATH_MAX];
    if (!mode || !watched(of_descriptor(fd, path))) return real(fd);
    if (breaks(path, 0, 0)) return -1;
    mark(path, 0);
    return real(fd);
}

static int opening(int folder, const char *path, int flags) {
    char whole[PATH_MAX];
    if (!mode || !(flags & (O_WRONLY | O_RDWR))) return 0;
    const char *name = absolute(folder, path, whole);
    return breaks(name, (flags & O_CREAT) && access(name, F_OK) != 0, 0);
}

#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        REAL(name); \
        va_list more; va_start(more, flags); mode_t rights = va_arg(more, mode_t); va_end(more); \
        return opening(AT_FDCWD, path, flags) ? -1 : real(path, flags, rights); \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name) \
    int name(int folder, const char *path, int flags, ...) { \
        REAL(name); \
        va_list more; va_start(more, flags); mode_t rights = va_arg(more, mode_t); va_end(more); \
        return opening(folder, path, flags) ? -1 : real(folder, path, flags, rights); \
    }
OPENAT(openat)
OPENAT(openat64)

int rename(const char *from, const char *to) {
    REAL(rename);
    char whole[PATH_MAX], other[PATH_MAX];
    if (!mode) return real(from, to);
    const char *target = absolute(AT_FDCWD, to, whole);
    if (breaks(target, 0, 0)) return -1;
    moved(absolute(AT_FDCWD, from, other), target);
    return real(from, to);
}

int unlink(const char *path) {
    REAL(unlink);
    char whole[PATH_MAX];
    return mode && breaks(absolute(AT_FDCWD, path, whole), 0, 0) ? -1 : real(path);
}

int unlinkat(int folder, const char *path, int flags) {
    REAL(unlinkat);
    char whole[PATH_MAX];
    return mode && breaks(absolute(folder, path, whole), 0, 0) ? -1 : real(folder, path, flags);
}

int rmdir(const char *path) {
    REAL(rmdir);
    char whole[PATH_MAX];
    return mode && breaks(absolute(AT_FDCWD, path, whole), 0, 0) ? -1 : real(path);
}

int mkdir(const char *path, mode_t rights) {
    REAL(mkdir);
    char whole[PATH_MAX];
    return mode && breaks(absolute(AT_FDCWD, path, whole), 1, 0) ? -1 : real(path, rights);
}
