"""Which loops the paper's identities, exact simulation and mean costs cover.

What the statements of witnesses cover is in the checker's own table of keys.
"""

from collections.abc import Iterator

from netem.core.errors import CallerError
from noack.core.cached_method import cached_method
from noack.scenario.scenario import Scenario


def _of_other_loops(scenario: Scenario) -> Iterator[str]:
    """Yield why a loop is not one with u = K x_c, a rule of noack, and without acknowledgements."""
    controller = scenario.controller
    if scenario.protocol.acknowledges:
        yield (
            'network.protocol = "ack": x_s is reset only when an acknowledgement returns, so ‖e_s‖ exceeds '
            "the threshold while the sensor waits, and (I1) does not hold"
        )
    if not controller.is_linear:
        yield f'controller.kind = "{controller.kind}": u is not K x_c'
    if controller.update_timeout_s is not None:
        yield (
            f"controller.update_timeout_s = {controller.update_timeout_s:g}: without a recent update, u is "
            "not K x_c"
        )
    if not scenario.trigger.is_rule:
        yield (
            f'trigger.policy = "{scenario.trigger.policy}": it is none of noack\'s rules; a class of your '
            "own decides at measurements only"
        )


def _of_nonlinear_loops(scenario: Scenario) -> Iterator[str]:
    if not scenario.coverage.is_linear:
        kind = scenario.plant.system.kind
        yield f'plant.system.kind = "{kind}": the plant is not given by matrices A and B'
    if scenario.model.load_states:
        yield f"model.load_states = {scenario.model.load_states}: a constant load does not decay"


def _of_disturbed_loops(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield what exact simulation has none of, and what to leave out."""
    plant, network = scenario.plant, scenario.network
    if plant.disturbances:
        kind = plant.disturbances[0].kind
        yield f'plant.disturbances.kind = "{kind}": the plant is disturbed', "plant.disturbances"
    if plant.measurement.is_noisy:
        yield "plant.measurement: the state is measured with noise", "the noise"
    if scenario.observer is not None:
        yield f'observer.kind = "{scenario.observer.kind}": the state is estimated', "observer"
    if network.actuation is not None:
        yield "network.actuation: actuations may be lost or late", "network.actuation"
    if scenario.controller.reference is not None:
        yield (
            "controller.reference: the loop follows a reference that changes over time",
            "controller.reference",
        )


@cached_method
def is_papers_loop(scenario: Scenario) -> bool:
    """Whether u = K x_c, x_s is reset at every event, and the trigger is a rule of noack."""
    return next(_of_other_loops(scenario), None) is None


@cached_method
def nonlinear_because(scenario: Scenario) -> str | None:
    """Return why a loop is not a linear one, with u = K x_c; None: it is. The line begins with a key."""
    return next(iter([*_of_nonlinear_loops(scenario), *_of_other_loops(scenario)]), None)


def is_linear_loop(scenario: Scenario) -> bool:
    """Whether the plant is linear and u = K x_c."""
    return nonlinear_because(scenario) is None


def require_linear(scenario: Scenario) -> None:
    """Raise CallerError unless the plant is linear and u = K x_c."""
    if (reason := nonlinear_because(scenario)) is not None:
        raise CallerError(f"{reason}; this needs a linear plant with u = K x_c")


def require_exact(scenario: Scenario) -> None:
    """Raise CallerError if exact simulation does not cover a scenario."""
    if (reason := nonlinear_because(scenario)) is not None:
        raise CallerError(
            f"{reason}; this needs a linear plant with u = K x_c and a trigger rule of noack, without "
            "acknowledgements, lost actuations, disturbances, noise and observer"
        )
    for reason, cause in _of_disturbed_loops(scenario):
        raise CallerError(f"{reason}; this needs a loop without it: leave {cause} out")
