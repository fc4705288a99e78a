/* The functions of FMI 3.0. */
#include "fmi.h"

#include <stdio.h>
#include <stdlib.h>

#pragma GCC diagnostic ignored "-Wunused-parameter" /* FMI has many that do not matter here */
#pragma GCC visibility push(default)

typedef enum { FMI_OK, FMI_ERROR = 3 } status;
enum mode { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };
enum { DRIFT_NS = 1000 }; /* between a sum of an importer's steps, in double, and ours */

static status fail(const fmu *instance, const char *text) {
    if (instance != NULL && instance->log_message != NULL)
        instance->log_message(instance->environment, FMI_ERROR, "logStatusError", text);
    return FMI_ERROR;
}

/* Whether a function may be called in the present mode. */
static int is_in(const fmu *instance, int first, int last, const char *function) {
    char text[96];
    if (instance == NULL || is_between(first, instance->image->mode, last))
        return instance != NULL;
    snprintf(text, sizeof text, "%s must not be called now", function);
    return fail(instance, text) == FMI_OK;
}

const char *fmi3GetVersion(void) { return "3.0"; }

status fmi3SetDebugLogging(fmu *instance, _Bool on, size_t count, const char *categories[]) {
    return FMI_OK; /* errors are always logged, and nothing else is */
}

void fmi3FreeInstance(fmu *instance) {
    if (instance == NULL)
        return;
    free(instance->image);
    free(instance->initial);
    free(instance);
}

fmu *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *folder, _Bool visible, _Bool logging,
    _Bool events, _Bool early, const uint32_t required[], size_t required_count, void *environment,
    void (*log_message)(void *, int, const char *, const char *), void *intermediate) {
    fmu *instance = calloc(1, sizeof *instance);
    char own[2 * NOACK_TAG_BYTES + 1] = "";
    if (instance == NULL)
        return NULL;
    instance->environment = environment;
    instance->log_message = log_message;
    const char *wrong = open_image(instance, folder);
    for (int k = 0; wrong == NULL && k < NOACK_TAG_BYTES; k++)
        snprintf(own + 2 * k, 3, "%02x", instance->image->tag[k]);
    if (wrong == NULL && (token == NULL || strcmp(token, own) != 0))
        wrong = "noack.bin does not belong to modelDescription.xml: their tokens differ";
    if (wrong == NULL)
        return instance;
    fail(instance, wrong);
    fmi3FreeInstance(instance);
    return NULL;
}

static status go(fmu *instance, int from, int to, const char *function) {
    if (!is_in(instance, from, from, function))
        return FMI_ERROR;
    instance->image->mode = to;
    return FMI_OK;
}

status fmi3EnterInitializationMode(
    fmu *instance, _Bool tolerates, double tolerance, double start_s, _Bool stops, double stop_s) {
    if (instance != NULL && start_s != 0.0)
        return fail(instance, "the start time must be 0");
    return go(instance, INSTANTIATED, INITIALIZING, __func__);
}

status fmi3ExitInitializationMode(fmu *instance) {
    return go(instance, INITIALIZING, STEPPING, __func__);
}

status fmi3Terminate(fmu *instance) { return go(instance, STEPPING, TERMINATED, __func__); }

status fmi3DoStep(
    fmu *instance, double from_s, double step_s, _Bool is_final, _Bool *needs_event, _Bool *ends,
    _Bool *returns_early, double *reached_s) {
    if (!is_in(instance, STEPPING, STEPPING, __func__))
        return FMI_ERROR;
    noack_fmu_image *image = instance->image;
    int64_t from_ns = ns_of(from_s), to_ns = ns_of(from_s + step_s);
    const char *wrong;
    if (from_ns < 0 || to_ns <= image->now_ns)
        wrong = "a step must go forward, at times below 4,000,000 s";
    else if (!is_between(image->now_ns - DRIFT_NS, from_ns, image->now_ns + DRIFT_NS))
        wrong = "a step must begin where the last one ended";
    else
        wrong = step(instance, to_ns);
    *needs_event = *ends = *returns_early = 0;
    memcpy(reached_s, values_of(image, NOACK_FMU_TIME_S), sizeof *reached_s);
    if (wrong == NULL)
        return FMI_OK;
    image->mode = TERMINATED;
    return fail(instance, wrong);
}

/* Values: all have 8 bytes. */

static status exchange(
    const fmu *instance, int is_real, int sets, const uint32_t *references, size_t count,
    uint8_t *numbers, size_t number_count) {
    if (!is_in(instance, INSTANTIATED, sets ? STEPPING : TERMINATED, sets ? "fmi3Set" : "fmi3Get"))
        return FMI_ERROR;
    for (size_t k = 0; k < count; k++) {
        int is_known = references[k] < NOACK_FMU_VARIABLES;
        const noack_fmu_values *values = &instance->image->values[is_known ? references[k] : 0];
        if (!is_known || values->count == 0 || values->is_real != is_real
            || (sets && !values->is_input))
            return fail(instance, "a value reference is not one of the variables of this type");
        if ((size_t)values->count > number_count)
            return fail(instance, "there are fewer values than the variables have");
        void *own = values_of(instance->image, (int)references[k]);
        size_t bytes = (size_t)values->count * 8;
        memcpy(sets ? own : numbers, sets ? numbers : own, bytes);
        numbers += bytes;
        number_count -= (size_t)values->count;
    }
    return number_count == 0 ? FMI_OK
                             : fail(instance, "there are more values than the variables have");
}

#define VALUES(name, type, is_real)                                                                \
    status fmi3Get##name(fmu *f, const uint32_t *r, size_t n, type *v, size_t count) {             \
        return exchange(f, is_real, 0, r, n, (uint8_t *)v, count);                                 \
    }                                                                                              \
    status fmi3Set##name(fmu *f, const uint32_t *r, size_t n, const type *v, size_t count) {       \
        return exchange(f, is_real, 1, r, n, (uint8_t *)v, count);                                 \
    }

VALUES(Float64, double, 1)
VALUES(Int64, int64_t, 0)

/* States: copies of the image at address 0. Serialised, one has its own check sum as its tag. */

static status save(const fmu *instance, const void *image, void **state) {
    size_t bytes = (size_t)instance->initial->bytes;
    if (*state == NULL && (*state = malloc(bytes)) == NULL)
        return fail(instance, "there is no memory");
    memcpy(*state, image, bytes);
    return FMI_OK;
}

status fmi3GetFMUState(fmu *instance, void **state) {
    if (instance == NULL || save(instance, instance->image, state) != FMI_OK)
        return FMI_ERROR;
    set_pointers(*state, 0);
    return FMI_OK;
}

status fmi3SetFMUState(fmu *instance, const void *state) {
    if (instance == NULL || state == NULL)
        return fail(instance, "there is no state");
    memcpy(instance->image, state, (size_t)instance->initial->bytes);
    set_pointers(instance->image, (uintptr_t)instance->image);
    return FMI_OK;
}

status fmi3Reset(fmu *instance) {
    return fmi3SetFMUState(instance, instance == NULL ? NULL : instance->initial);
}

status fmi3FreeFMUState(fmu *instance, void **state) {
    free(*state);
    *state = NULL;
    return FMI_OK;
}

status fmi3SerializedFMUStateSize(fmu *instance, const void *state, size_t *count) {
    *count = instance == NULL ? 0 : (size_t)instance->initial->bytes;
    return instance == NULL ? FMI_ERROR : FMI_OK;
}

/* The check sum of a state, which differs from that of the same bytes in another FMU. */
static void tag_state(const fmu *instance, const noack_fmu_image *state, uint8_t *tag) {
    tag_image(state, tag);
    for (int k = 0; k < NOACK_TAG_BYTES; k++)
        tag[k] ^= instance->initial->tag[k];
}

status fmi3SerializeFMUState(fmu *instance, const void *state, uint8_t *bytes, size_t count) {
    if (instance == NULL || state == NULL || count != (size_t)instance->initial->bytes)
        return fail(instance, "there is no state, or the memory for it has the wrong size");
    memcpy(bytes, state, count);
    tag_state(instance, state, bytes);
    return FMI_OK;
}

status fmi3DeserializeFMUState(fmu *instance, const uint8_t *bytes, size_t count, void **state) {
    uint8_t tag[NOACK_TAG_BYTES] = {0};
    if (instance == NULL)
        return FMI_ERROR;
    if (count != (size_t)instance->initial->bytes)
        return fail(instance, "the state is not one of this FMU");
    if (save(instance, bytes, state) != FMI_OK)
        return FMI_ERROR;
    noack_fmu_image *image = *state;
    int has_size = image->bytes == instance->initial->bytes;
    if (has_size)
        tag_state(instance, image, tag);
    if (!has_size || memcmp(image->tag, tag, sizeof tag) != 0) {
        fmi3FreeFMUState(instance, state);
        return fail(instance, "the state is not one of this FMU, or it is damaged");
    }
    memcpy(image->tag, instance->initial->tag, sizeof tag);
    return FMI_OK;
}

/* What these FMUs do not have. Importers look all functions up; arguments are not read. */
#define REFUSE(name)                                                                               \
    status fmi3##name(const fmu *instance) {                                                       \
        return fail(instance, "fmi3" #name " is not a function of this FMU");                      \
    }
#define REFUSE_BOTH(name) REFUSE(Get##name) REFUSE(Set##name)
#define REFUSE_KIND(name)                                                                          \
    void *fmi3Instantiate##name(                                                                   \
        const char *n, const char *token, const char *folder, _Bool visible, _Bool logging,        \
        void *environment, void (*log_message)(void *, int, const char *, const char *)) {         \
        fmu none = {.environment = environment, .log_message = log_message};                       \
        fail(&none, "this FMU is for co-simulation only");                                         \
        return NULL;                                                                               \
    }
REFUSE_KIND(ModelExchange)
REFUSE_KIND(ScheduledExecution)
// clang-format off
REFUSE_BOTH(Float32) REFUSE_BOTH(Int8) REFUSE_BOTH(UInt8) REFUSE_BOTH(Int16) REFUSE_BOTH(UInt16)
REFUSE_BOTH(Int32) REFUSE_BOTH(UInt32) REFUSE_BOTH(UInt64) REFUSE_BOTH(Boolean)
REFUSE_BOTH(String) REFUSE_BOTH(Binary) REFUSE_BOTH(Clock) REFUSE_BOTH(IntervalDecimal)
REFUSE_BOTH(IntervalFraction) REFUSE_BOTH(ShiftDecimal) REFUSE_BOTH(ShiftFraction)
REFUSE_BOTH(ContinuousStates) REFUSE(EnterConfigurationMode) REFUSE(ExitConfigurationMode)
REFUSE(EnterEventMode) REFUSE(EnterStepMode) REFUSE(EnterContinuousTimeMode)
REFUSE(EvaluateDiscreteStates) REFUSE(UpdateDiscreteStates) REFUSE(GetVariableDependencies)
REFUSE(GetNumberOfVariableDependencies) REFUSE(GetDirectionalDerivative)
REFUSE(GetAdjointDerivative) REFUSE(GetOutputDerivatives) REFUSE(ActivateModelPartition)
REFUSE(CompletedIntegratorStep) REFUSE(SetTime) REFUSE(GetContinuousStateDerivatives)
REFUSE(GetEventIndicators) REFUSE(GetNominalsOfContinuousStates)
REFUSE(GetNumberOfEventIndicators) REFUSE(GetNumberOfContinuousStates)
    // clang-format on
