/* The controller: runs the model x_c, which only a delivered update resets (eq:ModCont).

   At an update x_c <- e^(H(t - t_i)) x(t_i), so that a late update still restores x_c = x_s. At
   every tick the controller sends the input of its control law: u = K(x_c - x_r) + u_r, unless the
   user's law gives it. Before its first update it sends a declared safe input, unless x(0) is
   given. If the newest update is too old, it sends the safe input, or its last input again. The
   model's time advances with ticks and updates and never runs backward: an update older
   than the last tick is propagated to the time of that tick, a newer one advances the model. */
#include <stdlib.h>

#include "loop.h"

int64_t noack_controller_handle(
    noack_controller *controller, const noack_message *message, int64_t now_ns,
    noack_output *output) {
    noack_machine *machine = &controller->machine;
    int64_t n = machine->n, event_ns = message->t_ns;
    int64_t model_ns = max_of(controller->model_ns, event_ns);
    while (model_ns >= machine->change_ns)
        if (!ask(machine, NOACK_ASK_CHANGE))
            return NOACK_NOT_ANSWERED;
    if (controller->is_user) {
        copy(n, message->vector, controller->x);
        controller->asked_ns = event_ns;
        if (!ask(machine, NOACK_ASK_UPDATE))
            return NOACK_NOT_ANSWERED;
    }
    double *x_c_before = controller->scratch;
    noack_model_advance(
        &controller->model, controller->x_c, controller->model_ns, model_ns, x_c_before);
    noack_model_advance(&controller->model, message->vector, event_ns, model_ns, controller->x_c);
    controller->model_ns = machine->reached_ns = model_ns;
    controller->update_ns = event_ns;
    controller->has_state = 1;
    begin_row(output, NOACK_MESSAGES, machine, message->sequence, event_ns, now_ns);
    put(output, model_ns);
    put_reals(output, n, message->vector);
    put_reals(output, n, x_c_before);
    put_reals(output, n, controller->x_c);
    put(output, message->sequence - 1 - controller->newest); /* in this order: newest may be -1 */
    controller->newest = message->sequence;
    if (controller->acknowledges)
        begin_message(output, NOACK_ACKNOWLEDGEMENT, message->sequence, event_ns);
    return NOACK_DONE;
}

/* u = K(x - x_r) + u_r at t_ns, or the answer of the user's law. */
static void apply_law(noack_controller *controller, int64_t t_ns, const double *x, double *u) {
    int64_t n = controller->machine.n, m = controller->machine.m;
    const noack_reference *reference = controller->model.reference;
    double *difference = controller->scratch + n, *u_r = controller->scratch + 3 * n + m;
    if (controller->is_user) {
        copy(m, controller->u, u);
        return;
    }
    if (!noack_reference_at(reference, t_ns, 0, n, difference)) {
        noack_product(m, n, controller->K, x, u);
        return;
    }
    for (int64_t k = 0; k < n; k++)
        difference[k] = x[k] - difference[k];
    noack_product(m, n, controller->K, difference, u);
    noack_reference_at(reference, t_ns, n, m, u_r);
    for (int64_t k = 0; k < m; k++)
        u[k] += u_r[k];
}

/* Replace u, the input before, by the input for t_ns, at which the model's state is x. */
static void choose_input(noack_controller *controller, int64_t t_ns, const double *x, double *u) {
    if (!controller->has_state)
        copy(controller->machine.m, controller->safe_input, u);
    else if (t_ns - controller->update_ns < controller->timeout_ns)
        apply_law(controller, t_ns, x, u);
    else if (!controller->holds_input)
        copy(controller->machine.m, controller->safe_input, u);
}

/* Append the inputs for the times one period, two periods ... after the model's time. */
static void append_predictions(noack_controller *controller, noack_output *output) {
    const noack_machine *machine = &controller->machine;
    int64_t n = machine->n, m = machine->m, t_ns = controller->model_ns, from_ns = t_ns;
    double *x = controller->scratch + 2 * n, *u = controller->scratch + 3 * n;
    copy(n, controller->x_c, x);
    copy(m, output->message.vector, u);
    for (int64_t k = 1; k < controller->predictions; k++) {
        if (controller->has_state) {
            int64_t next_ns =
                min_of(from_ns + whole_periods_ns(&machine->period, k), MESSAGE_TIMES_NS);
            noack_model_advance(&controller->model, x, t_ns, next_ns, x);
            t_ns = next_ns;
            choose_input(controller, t_ns, x, u);
        }
        append(output, m, u);
    }
}

int64_t noack_controller_tick(noack_controller *controller, int64_t now_ns, noack_output *output) {
    noack_machine *machine = &controller->machine;
    int64_t n = machine->n, m = machine->m;
    int64_t t_ns = time_of_tick_ns(machine, machine->step);
    int64_t model_ns = max_of(t_ns, controller->model_ns);
    while (model_ns >= machine->change_ns)
        if (!ask(machine, NOACK_ASK_CHANGE))
            return NOACK_NOT_ANSWERED;
    double *x_c = controller->scratch;
    noack_model_advance(&controller->model, controller->x_c, controller->model_ns, model_ns, x_c);
    if (controller->is_user && controller->has_state) {
        copy(n, x_c, controller->x);
        controller->asked_ns = t_ns;
        if (!ask(machine, NOACK_ASK_INPUT))
            return NOACK_NOT_ANSWERED;
    }
    copy(n, x_c, controller->x_c);
    controller->model_ns = machine->reached_ns = model_ns;
    int64_t sequence = machine->step++;
    begin_row(output, NOACK_TICKS, machine, sequence, t_ns, now_ns);
    begin_message(output, NOACK_ACTUATION, sequence, model_ns);
    double *u = output->message.vector;
    output->message.entries = m;
    copy(m, controller->u, u);
    choose_input(controller, model_ns, controller->x_c, u);
    copy(m, u, controller->u);
    put(output, model_ns);
    put_reals(output, n, controller->x_c);
    put_reals(output, m, u);
    append_predictions(controller, output);
    if (controller->carries_model)
        append(output, n, controller->x_c);
    return NOACK_DONE;
}

/* How it is made. ------------------------------------------------------------------------------ */

/* Check the numbers of a new controller, and complete them. */
static const char *check(noack_controller *controller) {
    noack_machine *machine = &controller->machine;
    const char *wrong = begin_machine(machine, NOACK_UPDATE);
    if (wrong != NULL)
        return wrong;
    int64_t n = machine->n, m = machine->m;
    if (machine->period.ns < 1)
        return "a controller has no period";
    if (!is_between(1, controller->predictions, NOACK_MAX_ENTRIES)
        || controller->predictions * m + (controller->carries_model ? n : 0) > NOACK_MAX_ENTRIES)
        return "an actuation has more than 64 entries";
    if (!is_model(&controller->model, n, n + m))
        return "a controller has no model of its size";
    if (controller->timeout_ns < 1)
        return "a controller has a timeout below 1 ns";
    machine->received.entries = n;
    controller->model_ns = controller->update_ns = controller->asked_ns = 0;
    controller->newest = NOACK_NO_SEQUENCE;
    return NULL;
}

noack_controller *noack_controller_new(const noack_controller *settings, const char **wrong) {
    noack_controller controller = *settings;
    if ((*wrong = check(&controller)) != NULL)
        return NULL;
    int64_t n = controller.machine.n, m = controller.machine.m;
    owned_array arrays[] = {
        {&controller.K, m * n, STATE}, {&controller.safe_input, m, STATE},
        {&controller.x_c, n, STATE},   {&controller.x, n, STATE},
        {&controller.u, m, STATE},     {&controller.scratch, 3 * n + 2 * m, STATE},
    };
    return with_arrays(&controller, sizeof controller, arrays, 6, NULL, wrong);
}

void noack_controller_free(noack_controller *controller) { free(controller); }
