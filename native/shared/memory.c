/* Memory of handles: arrays of zeros, and copies of what the caller has. */
#include <stdlib.h>

#include "shared.h"

void *zeros(int64_t count, size_t size) { return calloc((size_t)max_of(count, 1), size); }

void *copy_of(const void *elements, int64_t count, size_t size) {
    void *copied = zeros(count, size);
    if (copied != NULL && count > 0)
        memcpy(copied, elements, (size_t)count * size);
    return copied;
}

void *with_arrays(
    void *structure, size_t size, const owned_array *arrays, int count, const char *missing,
    const char **wrong) {
    const void *given;
    size_t total = size;
    for (int k = 0; k < count; k++) {
        memcpy(&given, arrays[k].pointer, sizeof given);
        if (given == NULL && arrays[k].kind == NEEDED) {
            *wrong = missing;
            return NULL;
        }
        total += (size_t)arrays[k].count * sizeof(double);
    }
    uint8_t *new = zeros(1, total), *next = new + size;
    for (int k = 0; new != NULL && k < count; k++) {
        size_t bytes = (size_t)arrays[k].count * sizeof(double);
        memcpy(&given, arrays[k].pointer, sizeof given);
        if (given == NULL && arrays[k].kind == OPTIONAL)
            continue;
        if (given != NULL)
            memcpy(next, given, bytes);
        memcpy(arrays[k].pointer, &next, sizeof next);
        next += bytes;
    }
    return new == NULL ? NULL : memcpy(new, structure, size);
}

int lengthen(void *array, int64_t before, int64_t after, size_t size) {
    void *old, *new;
    memcpy(&old, array, sizeof old);
    if ((size_t)after > PTRDIFF_MAX / size || (new = realloc(old, (size_t)after * size)) == NULL)
        return 0;
    memset((uint8_t *)new + (size_t)before * size, 0, (size_t)(after - before) * size);
    memcpy(array, &new, sizeof new);
    return 1;
}

void *zeros_in_lines(int64_t count, size_t size, void **memory) {
    *memory = calloc((size_t)count * size + LINE_BYTES, 1);
    return *memory == NULL ? NULL : (uint8_t *)*memory + (-(uintptr_t)*memory) % LINE_BYTES;
}
