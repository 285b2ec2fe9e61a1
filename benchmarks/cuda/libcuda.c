/* A libcuda that has no card behind it: what Dr.Jit asks of NVIDIA's driver, answered so that it writes its kernels.
 *
 *     gcc -O1 -shared -fPIC libcuda.c -o libcuda.so
 *
 * "Device memory" is memory of the host, so that copies and fills are real; a kernel that is launched does nothing, so
 * that what it would have computed stays as it was, 0 where it is new. Every module that is loaded is written into the
 * folder $CARD_MODULES as 000.ptx, 001.ptx, ... What a caller wants counted stands in `card_counts` (ctypes reads it).
 * The device says that it is of compute capability $CARD_CAPABILITY, e.g. 80; without, 80.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef unsigned long long address;

enum { LAUNCHES, SYNCHRONIZATIONS, COPIES, COPIED_BYTES, FILLS, ALLOCATED_BYTES, PEAK_BYTES, MODULES, COUNTS };
EXPORT long long card_counts[COUNTS];

/* Handles are numbers that are never followed; only different ones must differ. */
static void *handle(void) {
    static size_t last = 0;
    return (void *) ++last;
}

static int capability(void) {
    const char *text = getenv("CARD_CAPABILITY");
    return text ? atoi(text) : 80;
}

/* -- The device ---------------------------------------------------------------------------------------------------- */

EXPORT int cuInit(unsigned flags) { return 0; }
EXPORT int cuDriverGetVersion(int *version) { *version = 12090; return 0; }
EXPORT int cuDeviceGetCount(int *count) { *count = 1; return 0; }
EXPORT int cuDeviceGet(int *device, int index) { *device = index; return 0; }
EXPORT int cuDeviceGetName(char *name, int size, int device) { strncpy(name, "no card", size); return 0; }
EXPORT int cuDeviceTotalMem_v2(size_t *size, int device) { *size = (size_t) 80 << 30; return 0; }
EXPORT int cuDeviceCanAccessPeer(int *can, int one, int other) { *can = 0; return 0; }
EXPORT int cuDevicePrimaryCtxRetain(void **context, int device) { *context = handle(); return 0; }
EXPORT int cuPointerGetAttribute(void *value, int attribute, address at) { return 1; /* not memory of a device */ }

EXPORT int cuDeviceGetAttribute(int *value, int attribute, int device) {
    switch (attribute) {
        case 1:   *value = 1024; break;                     /* threads of a block, at most */
        case 8:   *value = 49152; break;                    /* bytes of shared memory of a block */
        case 10:  *value = 32; break;                       /* lanes of a warp */
        case 16:  *value = 108; break;                      /* multiprocessors, as many as an A100 has */
        case 75:  *value = capability() / 10; break;
        case 76:  *value = capability() % 10; break;
        case 81:  *value = 167936; break;                   /* bytes of shared memory of a multiprocessor */
        case 97:  *value = 166912; break;                   /* of a block that asks for more */
        case 115: *value = 0; break;                        /* memory pools: without them allocations are counted */
        default:  *value = 1;
    }
    return 0;
}

EXPORT int cuGetErrorName(int error, const char **name) { *name = "CARD"; return 0; }
EXPORT int cuGetErrorString(int error, const char **text) { *text = "refused by the libcuda without a card"; return 0; }

/* -- Memory -------------------------------------------------------------------------------------------------------- */

/* The size of a block stands in the 64 bytes before it. */
static void *allocate(size_t size) {
    char *block = calloc(1, size + 64);
    if (!block)
        return NULL;
    *(size_t *) block = size;
    card_counts[ALLOCATED_BYTES] += size;
    if (card_counts[ALLOCATED_BYTES] > card_counts[PEAK_BYTES])
        card_counts[PEAK_BYTES] = card_counts[ALLOCATED_BYTES];
    return block + 64;
}

static void release(void *at) {
    if (!at)
        return;
    char *block = (char *) at - 64;
    card_counts[ALLOCATED_BYTES] -= *(size_t *) block;
    free(block);
}

EXPORT int cuMemAlloc_v2(address *at, size_t size) { *at = (address) allocate(size); return *at ? 0 : 2; }
EXPORT int cuMemFree_v2(address at) { release((void *) at); return 0; }
EXPORT int cuMemAllocAsync(address *at, size_t size, void *stream) { return cuMemAlloc_v2(at, size); }
EXPORT int cuMemFreeAsync(address at, void *stream) { return cuMemFree_v2(at); }
EXPORT int cuMemAllocHost_v2(void **at, size_t size) { *at = calloc(1, size); return *at ? 0 : 2; }
EXPORT int cuMemFreeHost(void *at) { free(at); return 0; }
EXPORT int cuMemAdvise(address at, size_t size, int advice, int device) { return 0; }

static int copy(address to, address from, size_t size) {
    card_counts[COPIES]++;
    card_counts[COPIED_BYTES] += size;
    memmove((void *) to, (void *) from, size);
    return 0;
}

EXPORT int cuMemcpyAsync(address to, address from, size_t size, void *stream) { return copy(to, from, size); }
EXPORT int cuMemcpy(address to, address from, size_t size) {
    card_counts[SYNCHRONIZATIONS]++; /* the host waits for it */
    return copy(to, from, size);
}

#define FILL(name, type)                                                            \
    EXPORT int name(address at, type value, size_t count, void *stream) {           \
        card_counts[FILLS]++;                                                       \
        for (size_t i = 0; i < count; i++)                                          \
            ((type *) at)[i] = value;                                               \
        return 0;                                                                   \
    }
FILL(cuMemsetD8Async, unsigned char)
FILL(cuMemsetD16Async, unsigned short)
FILL(cuMemsetD32Async, unsigned)

/* -- Modules and launches ------------------------------------------------------------------------------------------ */

static int load(void **module, const char *text) {
    const char *folder = getenv("CARD_MODULES");
    *module = handle();
    if (folder) {
        char path[4096];
        snprintf(path, sizeof(path), "%s/%03lld.ptx", folder, card_counts[MODULES]);
        FILE *file = fopen(path, "w");
        if (!file)
            return 1;
        fputs(text, file);
        fclose(file);
    }
    card_counts[MODULES]++;
    return 0;
}

EXPORT int cuModuleLoadData(void **module, const void *image) { return load(module, image); }
EXPORT int cuModuleLoadDataEx(void **module, const void *image, unsigned count, int *options, void **values) {
    return load(module, image);
}
EXPORT int cuModuleUnload(void *module) { return 0; }
EXPORT int cuModuleGetFunction(void **function, void *module, const char *name) { *function = handle(); return 0; }
EXPORT int cuFuncSetAttribute(void *function, int attribute, int value) { return 0; }
EXPORT int cuOccupancyMaxPotentialBlockSize(int *grid, int *block, void *function, void *size, size_t shared, int most) {
    *grid = 108;
    *block = 256;
    return 0;
}
EXPORT int cuLaunchKernel(void *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                          unsigned shared, void *stream, void **parameters, void **extra) {
    card_counts[LAUNCHES]++;
    return 0;
}
EXPORT int cuLaunchHostFunc(void *stream, void (*function)(void *), void *argument) { function(argument); return 0; }

/* -- Streams and events: everything has happened when a call returns ----------------------------------------------- */

EXPORT int cuStreamCreate(void **stream, unsigned flags) { *stream = handle(); return 0; }
EXPORT int cuEventCreate(void **event, unsigned flags) { *event = handle(); return 0; }
EXPORT int cuEventElapsedTime(float *milliseconds, void *first, void *last) { *milliseconds = 1; return 0; }

#define WAIT(name) EXPORT int name(void *what) { card_counts[SYNCHRONIZATIONS]++; return 0; }
WAIT(cuStreamSynchronize)
WAIT(cuEventSynchronize)
EXPORT int cuCtxSynchronize(void) { card_counts[SYNCHRONIZATIONS]++; return 0; }

/* What needs no answer. */
#define NOTHING(name) EXPORT int name(void) { return 0; }
NOTHING(cuCtxEnablePeerAccess)
NOTHING(cuCtxPopCurrent_v2)
NOTHING(cuCtxPushCurrent_v2)
NOTHING(cuDevicePrimaryCtxRelease_v2)
NOTHING(cuEventDestroy_v2)
NOTHING(cuEventQuery)
NOTHING(cuEventRecord)
NOTHING(cuProfilerStart)
NOTHING(cuProfilerStop)
NOTHING(cuStreamDestroy_v2)
NOTHING(cuStreamWaitEvent)
NOTHING(cuStreamWaitEvent_ptsz)

/* What nothing here uses: textures, surfaces, graphics. Dr.Jit wants the names; a call is an error. */
#define REFUSED(name) EXPORT int name(void) { return 801; }
REFUSED(cuArray3DCreate_v2)
REFUSED(cuArray3DGetDescriptor_v2)
REFUSED(cuArrayCreate_v2)
REFUSED(cuArrayDestroy)
REFUSED(cuGraphicsGLRegisterBuffer)
REFUSED(cuGraphicsGLRegisterImage)
REFUSED(cuGraphicsMapResources)
REFUSED(cuGraphicsResourceGetMappedPointer)
REFUSED(cuGraphicsSubResourceGetMappedArray)
REFUSED(cuGraphicsUnmapResources)
REFUSED(cuGraphicsUnregisterResource)
REFUSED(cuMemcpy2DAsync_v2)
REFUSED(cuMemcpy3DAsync_v2)
REFUSED(cuSurfObjectCreate)
REFUSED(cuSurfObjectDestroy)
REFUSED(cuTexObjectCreate)
REFUSED(cuTexObjectDestroy)
REFUSED(cuTexObjectGetResourceDesc)
