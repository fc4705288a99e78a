/* The image of an instance: a copy of it is a state, the first one is that of the file.

   Python has written it from structures that the core's checks accepted. It is used if it is for
   this very library, and unchanged by its check sum; whoever forges it can as well replace the
   library beside it. */
#include "fmi.h"

#include <stdio.h>
#include <stdlib.h>

enum { MOST_BYTES = 1 << 30 };

void set_pointers(noack_fmu_image *image, uintptr_t address) {
    uint8_t *bytes = (uint8_t *)image;
    const noack_fmu_pointer *pointers = (const void *)(bytes + image->pointers_at);
    for (int64_t k = 0; k < image->pointer_count; k++) {
        uintptr_t target = address + (uintptr_t)pointers[k].target;
        memcpy(bytes + pointers[k].place, &target, sizeof target);
    }
}

void tag_image(const noack_fmu_image *image, uint8_t tag[NOACK_TAG_BYTES]) {
    static const uint8_t key[NOACK_KEY_BYTES];
    noack_wire wire;
    noack_wire_key(&wire, key);
    noack_wire_tag(
        &wire, image->bytes - NOACK_TAG_BYTES, (const uint8_t *)image + NOACK_TAG_BYTES, tag);
}

static const char *read_image(FILE *file, noack_fmu_image **image) {
    uint8_t tag[NOACK_TAG_BYTES];
    noack_fmu_image head;
    if (fread(&head, sizeof head, 1, file) != 1)
        return "noack.bin is too short";
    if (memcmp(head.sources, noack_sources(), sizeof head.sources) != 0)
        return "noack.bin is for another version of noack than the library beside it";
    if (!is_between(sizeof head, head.bytes, MOST_BYTES)
        || (*image = malloc((size_t)head.bytes)) == NULL)
        return "noack.bin is too large";
    size_t rest = (size_t)head.bytes - sizeof head;
    **image = head;
    if (fread(*image + 1, 1, rest, file) != rest)
        return "noack.bin is too short";
    if (fgetc(file) != EOF)
        return "noack.bin is too long";
    tag_image(*image, tag);
    return memcmp(head.tag, tag, sizeof tag) == 0 ? NULL
                                                  : "noack.bin is damaged: its check sum is wrong";
}

const char *open_image(fmu *instance, const char *folder) {
    char path[4096];
    FILE *file = NULL;
    if (folder != NULL && snprintf(path, sizeof path, "%s/noack.bin", folder) < (int)sizeof path)
        file = fopen(path, "rb");
    if (file == NULL)
        return "noack.bin cannot be read in the folder of the resources";
    const char *wrong = read_image(file, &instance->initial);
    fclose(file);
    if (wrong != NULL)
        return wrong;
    const noack_fmu_image *initial = instance->initial;
    uint8_t *image = malloc((size_t)initial->bytes);
    if (image == NULL)
        return "there is no memory";
    instance->image = memcpy(image, initial, (size_t)initial->bytes);
    set_pointers(instance->image, (uintptr_t)image);
    if (initial->channel_at != 0)
        instance->channel = (void *)(image + initial->channel_at);
    if (initial->controller_at != 0)
        instance->controller = (void *)(image + initial->controller_at);
    return NULL;
}
