/* An OptiX that has no card behind it, for rays through Mitsuba's acceleration structure: see libcuda.c.
 *
 *     gcc -O1 -shared -fPIC libnvoptix.c -o libnvoptix.so
 *
 * It speaks ABI 87 (OptiX 8.0), which Dr.Jit falls back to, and answers what Dr.Jit and Mitsuba call of it. Modules are
 * written into $CARD_MODULES as optix-000.ptx, ...; structures are never built, and a launch does nothing.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { ABI = 87, TABLE = 48, UNSUPPORTED = 7801, COMPLETED = 0x2364 };

static size_t last = 0;
static void *handle(void) { return (void *) ++last; }

static const char *name(int error) { return "refused by the OptiX without a card"; }
static int nothing(void) { return 0; }
static int refused(void) { return 7200; /* not supported */ }

static int context_create(void *from, void *options, void **context) { *context = handle(); return 0; }

static int write_module(const char *text, size_t size) {
    static int number = 0;
    const char *folder = getenv("CARD_MODULES");
    if (folder) {
        char path[4096];
        snprintf(path, sizeof(path), "%s/optix-%03d.ptx", folder, number++);
        FILE *file = fopen(path, "w");
        if (!file)
            return 7001;
        fwrite(text, 1, size, file);
        fclose(file);
    }
    return 0;
}

static int module_create(void *context, void *options, void *pipeline, const char *text, size_t size, char *log,
                         size_t *logged, void **module) {
    *module = handle();
    return write_module(text, size);
}
static int module_create_with_tasks(void *context, void *options, void *pipeline, const char *text, size_t size,
                                    char *log, size_t *logged, void **module, void **task) {
    *module = handle();
    *task = handle();
    return write_module(text, size);
}
static int module_state(void *module, int *state) { *state = COMPLETED; return 0; }
static int builtin_module(void *context, void *options, void *pipeline, void *of, void **module) {
    *module = handle();
    return 0;
}
static int execute(void *task, void **more, unsigned most, unsigned *count) { *count = 0; return 0; }
static int groups_create(void *context, void *descriptions, unsigned count, void *options, char *log, size_t *logged,
                         void **groups) {
    for (unsigned i = 0; i < count; i++)
        groups[i] = handle();
    return 0;
}
static int stack_size(void *group, unsigned sizes[7], void *pipeline) { memset(sizes, 0, 7 * 4); return 0; }
static int pipeline_create(void *context, void *compile, void *link, void *groups, unsigned count, char *log,
                           size_t *logged, void **pipeline) {
    *pipeline = handle();
    return 0;
}
static int memory_usage(void *context, void *options, void *inputs, unsigned count, size_t sizes[3]) {
    sizes[0] = sizes[1] = sizes[2] = 1024; /* of the structure, to build it, to update it */
    return 0;
}
static int build(void *context, void *stream, void *options, void *inputs, unsigned count, size_t temporary,
                 size_t temporary_size, size_t output, size_t output_size, size_t *structure, void *emitted,
                 unsigned emit) {
    *structure = ++last;
    return 0;
}
static int compact(void *context, void *stream, size_t structure, size_t output, size_t size, size_t *compacted) {
    *compacted = ++last;
    return 0;
}

__attribute__((visibility("default")))
int optixQueryFunctionTable(int abi, unsigned count, void *keys, void *values, void **table, size_t size) {
    if (abi != ABI || size != TABLE * sizeof(void *))
        return UNSUPPORTED;
    for (int i = 0; i < TABLE; i++)
        table[i] = refused;
    table[0] = name;
    table[1] = name;
    table[2] = context_create;
    table[3] = nothing;  /* context is destroyed */
    table[5] = nothing;  /* callback for the log */
    table[6] = nothing;  /* cache is enabled */
    table[7] = nothing;  /* where it is */
    table[8] = nothing;  /* how large it is */
    table[12] = module_create;
    table[13] = module_create_with_tasks;
    table[14] = module_state;
    table[15] = nothing;  /* module is destroyed */
    table[16] = builtin_module;
    table[17] = execute;
    table[18] = groups_create;
    table[19] = nothing;  /* group is destroyed */
    table[20] = stack_size;
    table[21] = pipeline_create;
    table[22] = nothing;  /* pipeline is destroyed */
    table[23] = nothing;  /* its stack size is set */
    table[24] = memory_usage;
    table[25] = build;
    table[29] = compact;
    table[38] = nothing;  /* header of a record is packed */
    table[39] = nothing;  /* launch */
    return 0;
}
