"""Random scenarios with few events, so that every pattern of dropouts can be tried."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from cosim.analysis.adversary.loop_flows import Objective, Pattern, SegmentFlow, measure_of
from cosim.simulation.continuous import ContinuousRun, continuous_loop_of, simulate_continuous
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.oracles.lossy_loops import System, systems

ALL_LOST = (False,) * 1000

_ATTEMPTS = 6
_PROBES = (ALL_LOST, (), (False, True) * 500)


def scenario_of(system: System, horizon_s: float, mode: str, floor: float) -> Scenario:
    """The scenario of a random loop with the loop's H in its models."""
    content = {
        "name": "random", "mode": mode, "horizon_s": round(horizon_s, 3),
        "model": {
            "A": (system.H - system.B @ system.K).tolist(), "B": system.B.tolist(),
            "gain": system.K.tolist(), "allow_unstable": True,
        },
        "plant": {
            "draw": "given", "A": system.A.tolist(), "B": system.B.tolist(),
            "initial_state": system.x0.tolist(),
        },
        "trigger": {
            "beta": system.beta, "alpha_per_s": system.alpha, "floor": floor,
            "weight": system.weight.tolist(),
        },
        "network": {
            "mansd": system.mansd, "constraints": constraints_of(system),
            "loss": {"model": "bernoulli", "probability": 0.5},
            "initial_sync": "known_state" if system.known_start else "first_packet",
        },
    }  # fmt: skip
    return resolve(validate(content, "random"))


def constraints_of(system: System) -> list[dict[str, Any]]:
    """The constraints of a random loop's guarantee, as in a scenario."""
    (losses, window), constraints = system.window, []
    if losses < window:
        constraints.append({"kind": "at_most", "losses": losses, "window": window})
    if system.recovery:
        constraints.append({"kind": "recovery", "deliveries": system.recovery})
    return constraints


@st.composite
def scenarios(draw: st.DrawFn, most_events: int, **fixed: Any) -> Scenario:
    """Loops with at most the given number of events and a threshold low enough for half of it."""
    system = draw(systems(**{"mismatch": 0.5} | fixed))
    horizon_s = 20.0 / float(np.abs(np.linalg.eigvals(system.H)).max())
    mode = draw(st.sampled_from(["model", "model", "model", "zoh"]))
    floor_share = draw(st.sampled_from([0.0, 0.0, 0.5]))
    for _ in range(_ATTEMPTS):
        resolved = scenario_of(system, horizon_s, mode, floor_share * system.beta)
        event_s = max((simulate(resolved, pattern).event_s for pattern in _PROBES), key=len)
        if len(event_s) >= most_events / 2:
            break
        system = replace(system, beta=system.beta / 4)
    if len(event_s) <= most_events:
        return resolved
    return resolved.model_copy(update={"horizon_s": float(event_s[most_events]) * 0.999})


def simulate(resolved: Scenario, pattern: Pattern) -> ContinuousRun:
    """Simulate one pattern with the reference simulator; the guarantee forces deliveries."""
    known_start = resolved.network.initial_sync == "known_state"
    so_far = ""  # one letter per event: D delivered, L lost

    def delivered(event: int) -> bool:
        nonlocal so_far
        arrives = (event == 0 and not known_start) or not may_be_lost(resolved, so_far)
        arrives = arrives or event >= len(pattern) or pattern[event]
        so_far += "D" if arrives else "L"
        return arrives

    return simulate_continuous(
        continuous_loop_of(resolved),
        horizon_s=resolved.horizon_s,
        delivered=delivered,
        known_start=known_start,
    )


def may_be_lost(resolved: Scenario, so_far: str) -> bool:
    """Whether the next update may be lost, from the definition of the guarantee."""
    network = resolved.network
    bursts = [len(burst) for burst in so_far.split("D")]
    if bursts[-1] >= network.mansd:
        return False
    for constraint in network.constraints:
        if constraint.kind == "at_most":
            recent = (so_far + "L")[-constraint.window :]
            allowed = recent.count("L") <= constraint.losses
        else:
            deliveries = len(so_far) - len(so_far.rstrip("D"))
            allowed = deliveries == 0 or "L" not in so_far or deliveries >= constraint.deliveries
        if not allowed:
            return False
    return True


def every_run(resolved: Scenario) -> Iterator[ContinuousRun]:
    """All admissible patterns, each simulated from the start.

    Counts like an odometer: the next pattern delivers the last lost update and loses all later
    updates that may be lost.
    """
    first = int(resolved.network.initial_sync == "first_packet")
    prefix: Pattern = ()
    while True:
        run = simulate(resolved, prefix + ALL_LOST)
        yield run
        decided = tuple(run.delivered.tolist())
        lost = [i for i in range(first, len(decided)) if not decided[i]]
        if not lost:
            return
        prefix = (*decided[: lost[-1]], True)


def flow_of(resolved: Scenario, objective: Objective, rate_per_s: float | None = None) -> SegmentFlow:
    system = continuous_loop_of(resolved)
    known_start = resolved.network.initial_sync == "known_state"
    measure = measure_of(system, objective, rate_per_s)
    return SegmentFlow(system, measure, resolved.horizon_s, known_start=known_start)
