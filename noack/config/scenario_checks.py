"""Checks of a scenario that concern several of its sections."""

from typing import TYPE_CHECKING

import numpy as np

from noack.config.setpoint import input_at
from noack.core.clock import NS_PER_S
from noack.impairments.loss_models.trace import TraceLoss
from noack.impairments.loss_prediction import with_kept_loss
from noack.protocol.wire_format import MAX_DIMENSION
from noack.settings.matrices import require_length, require_shape

if TYPE_CHECKING:
    from noack.config.scenario import Scenario


def check_sections(scenario: "Scenario") -> None:
    """Raise ValueError if two sections do not fit together; the message begins with the key."""
    timing = scenario.timing
    if timing.horizon_ns < timing.plant_period_ns:
        raise ValueError(
            f"horizon_s: shorter than one plant step ({timing.plant_period_ns / NS_PER_S} s)"
        )
    _check_plant(scenario)
    m = scenario.model.dimensions[1]
    require_length(scenario.controller.safe_input, "controller.safe_input", m, "one per input")
    check_setpoint(scenario)
    _check_observer(scenario)
    _check_watchdog(scenario)
    check_trigger(scenario)
    check_kept_loss(scenario)


def check_kept_loss(scenario: "Scenario") -> None:
    """Raise ValueError if a loss rate cannot be kept; with a trace, as soon as it has been read."""
    network = scenario.network
    for key, section in network.directions.items():
        link = section.link
        losses = [getattr(one, "loss", None) for one in link.impairments]
        if any(isinstance(one, TraceLoss) for one in losses):
            continue
        try:
            with_kept_loss(link)
        except ValueError as error:
            raise ValueError(f"{key}.loss: {error}") from None


def check_trigger(scenario: "Scenario") -> None:
    """Raise ValueError unless the trigger fits the model's dimensions and measurement period."""
    scenario.trigger.check(scenario.model.dimensions[0], _dimensions(scenario))
    scenario.trigger.check_period(scenario.timing.measurement_period_ns)


def check_setpoint(scenario: "Scenario") -> None:
    """Raise ValueError unless the model can rest at the set point and other settings allow one."""
    key, setpoint = "controller.setpoint", scenario.controller.setpoint
    require_length(setpoint, key, scenario.model.dimensions[0], "one per state")
    if setpoint is None:
        return
    if scenario.protocol.acknowledges:
        raise ValueError(f'{key}: not with network.protocol = "ack"')
    if not scenario.controller.is_linear:
        raise ValueError(f'{key}: not with controller.kind = "{scenario.controller.kind}"')
    if scenario.message_sizes.is_predictive:
        raise ValueError(
            f"{key}: the plant's watchdog does not have it; "
            'use plant.watchdog.policy = "hold" or "zero"'
        )
    try:
        input_at(*scenario.model.matrices, np.array(setpoint))
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def _check_plant(scenario: "Scenario") -> None:
    (n, m), plant, why = scenario.model.dimensions, scenario.plant, _dimensions(scenario)
    require_shape(plant.uncertainty_A, "plant.uncertainty_A", (n, n), why)
    require_shape(plant.uncertainty_B, "plant.uncertainty_B", (n, m), why)
    require_shape(plant.A, "plant.A", (n, n), why)
    require_shape(plant.B, "plant.B", (n, m), why)
    for key in ("initial_state", "initial_state_halfwidth"):
        require_length(getattr(plant, key), f"plant.{key}", n, "one per state")
    plant.system.check(n, m)
    _check_disturbances(scenario)
    plant.measurement.check(n, why)


def _check_disturbances(scenario: "Scenario") -> None:
    n, m = scenario.model.dimensions
    for number, one in enumerate(scenario.plant.disturbances):
        place = f"plant.disturbances.{number}"
        if one.at == "state" and not scenario.coverage.is_linear:
            raise ValueError(
                f'{place}.at: "state" needs a linear plant; this one can be disturbed at "input"'
            )
        size, why = (m, "one per input") if one.at == "input" else (n, "one per state")
        require_length(one.entries, f"{place}.{one.entries_key}", size, f'at = "{one.at}": {why}')


def _check_observer(scenario: "Scenario") -> None:
    (n, m), plant, observer = scenario.model.dimensions, scenario.plant, scenario.observer
    sizes = scenario.message_sizes
    if observer is None:
        if not plant.measurement.selects_all(n):
            raise ValueError(
                "plant.measurement.C: without an [observer] the sensor has to measure every "
                "state; give an [observer], or no C"
            )
        return
    observer.check(n, m, sizes.outputs, plant.noise_variances(n, m))
    if sizes.measurement_entries > MAX_DIMENSION:
        raise ValueError(
            "plant.measure_every: with an observer a measurement carries y and the inputs of "
            f"{plant.measure_every} steps, {sizes.outputs} + {sizes.inputs_reported} numbers; "
            f"at most {MAX_DIMENSION} fit"
        )


def _check_watchdog(scenario: "Scenario") -> None:
    timing, (n, m) = scenario.timing, scenario.model.dimensions
    if timing.actuation_timeout_ns < timing.predicted_ns:
        several = "" if scenario.controller.predictions == 1 else " times controller.predictions"
        raise ValueError(
            f"plant.watchdog.timeout_s: shorter than a period of the controller{several} "
            f"({timing.predicted_ns / NS_PER_S} s)"
        )
    if scenario.controller.predictions > 1 and not scenario.controller.is_linear:
        raise ValueError(
            "controller.predictions: needs u = K x_c; "
            f'not with controller.kind = "{scenario.controller.kind}"'
        )
    if scenario.message_sizes.is_predictive and not scenario.controller.is_linear:
        raise ValueError(
            'plant.watchdog.policy: "model" predicts u = K x_c; '
            f'not with controller.kind = "{scenario.controller.kind}"'
        )
    if scenario.message_sizes.actuation_entries <= MAX_DIMENSION:
        return
    predictive = scenario.message_sizes.is_predictive
    if (predictions := scenario.controller.predictions) > 1:
        more = f" and {n} of x_c" if predictive else ""
        raise ValueError(
            f"controller.predictions: an actuation carries {predictions} x {m} inputs{more}; "
            f"at most {MAX_DIMENSION} numbers fit"
        )
    raise ValueError(
        'plant.watchdog.policy: with "model" an actuation carries u and x_c, '
        f"{m} + {n} numbers; at most {MAX_DIMENSION} fit"
    )


def _dimensions(scenario: "Scenario") -> str:
    n, m = scenario.model.dimensions
    return f"the model has {n} states and {m} inputs"
