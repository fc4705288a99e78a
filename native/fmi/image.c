/* The image of an instance: a copy of it is a state, the first one is that of the file. */
#include "fmi.h"

#include <stdio.h>
#include <stdlib.h>

enum { MOST_BYTES = 1 << 30 };

void point(noack_fmu_image *image, uintptr_t address) {
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

/* Whether rows of 8 bytes are within the image. */
static int has(const noack_fmu_image *image, int64_t at, int64_t rows, int64_t words) {
    return is_between(1, at, image->bytes) && at % 8 == 0
           && is_between(0, rows, (image->bytes - at) / (8 * words));
}

static const char *check_layout(const noack_fmu_image *image) {
    const noack_fmu_pointer *pointers = (const void *)((const uint8_t *)image + image->pointers_at);
    int is_right = has(image, image->pointers_at, image->pointer_count, 2)
                   && is_between(1, image->n, NOACK_MAX_ENTRIES) && image->packets >= 1;
    for (int64_t k = 0; is_right && k < image->pointer_count; k++)
        is_right = has(image, pointers[k].place, 1, 1) && has(image, pointers[k].target, 0, 1);
    for (int k = 0; is_right && k < NOACK_FMU_VARIABLES; k++)
        is_right = has(image, image->values[k].at, image->values[k].count, 1);
    return is_right ? NULL : "noack.bin has tables outside of it";
}

static const char *check_machine(fmu *instance) {
    const noack_channel *channel = instance->channel;
    const noack_controller *controller = instance->controller;
    if ((channel == NULL) == (controller == NULL))
        return "noack.bin is neither of a channel nor of a controller";
    if (controller != NULL)
        return controller->is_user || controller->machine.change_ns != INT64_MAX
                   ? "the controller needs Python"
                   : controller_check(controller);
    if (channel->is_scripted || channel->change_ns != INT64_MAX)
        return "the channel needs Python";
    const char *wrong = noack_channel_check(channel);
    return wrong != NULL ? wrong : noack_link_check(channel->links[0]);
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
    tag_image(*image, tag);
    return memcmp(head.tag, tag, sizeof tag) == 0 ? check_layout(*image)
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
    point(instance->image, (uintptr_t)image);
    if (initial->channel_at != 0)
        instance->channel = (void *)(image + initial->channel_at);
    if (initial->controller_at != 0)
        instance->controller = (void *)(image + initial->controller_at);
    return check_machine(instance);
}
