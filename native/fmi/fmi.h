/* The channel and the controller of a scenario as FMI 3.0 co-simulation; docs/howto.md has their
   variables, cosim/output/export/fmu_export.py writes their images. */
#ifndef NOACK_FMI_H
#define NOACK_FMI_H

#include "../loop/loop.h"

typedef struct {
    void *environment;
    void (*log_message)(void *environment, int status, const char *category, const char *message);
    noack_fmu_image *image, *initial;
    noack_channel *channel;       /* of a channel; else NULL */
    noack_controller *controller; /* of a controller; else NULL */
    noack_output output;
} fmu;

const char *noack_sources(void);

/* image.c: read the image of an instance; return NULL, or what is wrong. */
const char *open_image(fmu *instance, const char *folder);
/* Set the pointers of an image that is to be at an address. */
void set_pointers(noack_fmu_image *image, uintptr_t address);
void tag_image(const noack_fmu_image *image, uint8_t tag[NOACK_TAG_BYTES]);

/* steps.c: go from now_ns to a time; return NULL, or what is wrong. */
const char *step(fmu *instance, int64_t to_ns);
/* A time in ns; -1: it is out of range. */
int64_t ns_of(double t_s);

static inline void *values_of(const noack_fmu_image *image, int variable) {
    return (uint8_t *)image + image->values[variable].at;
}

#endif
