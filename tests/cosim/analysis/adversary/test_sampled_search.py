"""The search of the sampled loop, for every policy, against all patterns run by the machines."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.analysis.adversary import Objective, find_worst
from cosim.analysis.adversary.loop_flows import Pattern, SampledFlow, run_sampled
from cosim.analysis.adversary.worst_disturbances import disturbance_bounds
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.record.run_record import RunRecord
from cosim.simulation.sampled_loop import SampledLoop, Scales
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.certified_bounds import Quantity, ScenarioCertificate
from tests.helpers.example_rules import EXAMPLES

OWN = {
    "periodic": {"period_s": 0.25},
    "self_triggered": {"longest_s": 0.6},
    "decaying": {"beta": 0.2},
    "dynamic": {"eta_0": 0.0, "sigma": 0.2},
}
STEP_S, MOST_EVENTS = 0.05, 5
SURE = 1e-9


def scenario_of(
    trigger: dict[str, Any], *, horizon_s: float = 8.0, mode: str = "model", **sections: Any
) -> Scenario:
    """A small loop with M = 2."""
    plant = {
        "draw": "given", "A": [[0.0, 1.0], [2.0, -0.3]], "B": [[0.0], [1.1]],
        "initial_state": [0.5, -0.2], "rate_hz": 20.0,
    }  # fmt: skip
    content = {
        "name": "small", "mode": mode, "horizon_s": horizon_s,
        "model": {"A": [[0.0, 1.0], [1.2, -0.3]], "B": [[0.0], [1.0]], "gain": [[-5.0, -3.0]]},
        "plant": plant | sections.pop("plant", {}),
        "controller": {"rate_hz": 20.0} | sections.pop("controller", {}),
        "trigger": trigger,
        "network": {"mansd": 1, "loss": {"model": "bernoulli", "probability": 0.5}}
        | sections.pop("network", {}),
    } | sections  # fmt: skip
    return resolve(validate(content, "small"))


def run(resolved: Scenario, lost: Pattern, delay_ns: int = 0) -> tuple[RunRecord, Pattern]:
    """Run the machines; of two successive updates, and of the first, one is delivered."""
    fates: list[bool] = []

    def decide(data: bytes, now_ns: int) -> int | None:
        wants_loss = len(fates) < len(lost) and lost[len(fates)]
        fates.append(not (wants_loss and fates and fates[-1]))
        return delay_ns if fates[-1] else None

    record = simulate(resolved, decide)
    return record, tuple(fates)


def every_run(resolved: Scenario) -> Iterator[tuple[RunRecord, Pattern]]:
    """All admissible patterns: the next one delivers the last lost update, and loses all after."""
    prefix: Pattern = ()
    while True:
        record, delivered = run(resolved, (*prefix, *(True,) * 100))
        yield record, delivered
        lost = [i for i, arrives in enumerate(delivered) if not arrives]
        if not lost:
            return
        prefix = (*(not arrives for arrives in delivered[: lost[-1]]), False)


def event_steps(record: RunRecord) -> list[int]:
    return np.flatnonzero(record["sensor_measurement"]["event"] >= 0).tolist()


def value_of(
    record: RunRecord, delivered: Pattern, objective: Objective, certificate: ScenarioCertificate
) -> float:
    """The objective, from the definition."""
    x, steps, H = record["plant_step"]["x"], event_steps(record), record.loop.H
    t_s = np.arange(len(x)) * STEP_S
    if objective is Objective.INTER_EVENT:
        return -float(np.diff(steps).min()) * STEP_S if len(steps) > 1 else -np.inf
    if objective is Objective.COST:
        return float((x[1:] ** 2).sum() * STEP_S)
    level = np.ones(len(x))
    quantity: Quantity = "x" if objective is Objective.STATE else "e_c"
    if certificate.has(quantity):
        bound = certificate.bound(t_s, quantity)
        level = bound / bound[0]
    if objective is Objective.STATE:
        return float((np.linalg.norm(x, axis=1) / level).max())
    W = np.eye(2) if record.loop.weight is None else record.loop.weight
    arrived = [step for step, arrives in zip(steps, delivered, strict=True) if arrives]
    propagation, x_c, worst = expm(H * STEP_S), x[0], 0.0
    assert arrived[0] == 0
    for k in range(1, len(x)):
        x_c = propagation @ x_c
        worst = max(worst, float(np.linalg.norm(W @ (x_c - x[k]))) / level[k])  # before an update
        x_c = x[k] if k in arrived else x_c
    return worst


@pytest.mark.parametrize(
    ("policy", "mode"),
    [*((followed, "model") for followed in EXAMPLES), ("decaying", "zoh"), ("mixed", "zoh")],
)
def test_the_search_finds_the_worst_of_all_patterns(policy: str, mode: str) -> None:
    trigger = EXAMPLES[policy] | OWN.get(policy, {})
    resolved = scenario_of(trigger, mode=mode)
    events = max((event_steps(run(resolved, lost)[0]) for lost in ((), (True,) * 100)), key=len)
    if len(events) > MOST_EVENTS:
        resolved = scenario_of(trigger, mode=mode, horizon_s=events[MOST_EVENTS] * STEP_S)
    certificate = quick_certificate(resolved)
    runs = list(every_run(resolved))
    assert len(runs) > 4
    for objective in Objective:
        expected = max(value_of(*followed, objective, certificate) for followed in runs)
        worst = find_worst(resolved, objective, beam=0)
        worst_value = worst.value if objective is not Objective.INTER_EVENT else -(worst.value or np.inf)
        assert worst.exact
        assert worst_value == pytest.approx(expected, rel=SURE)
        assert not worst.breaches, worst
        record, delivered = run(resolved, tuple(not arrives for arrives in worst.pattern))
        assert delivered == worst.pattern, "the guarantee would have forced a delivery"
        assert worst.event_s == pytest.approx([STEP_S * k for k in event_steps(record)])


@pytest.mark.sanitized
@pytest.mark.parametrize(
    "sections",
    [
        {"network": {"impairments": [{"kind": "delay", "delay_s": 0.13}]}},
        {"controller": {"rate_hz": 8.0, "phase": 0.3, "safe_input": [0.4]}},
        {"controller": {"rate_hz": 62.5, "phase": 0.9}, "network": {"initial_sync": "known_state"}},
        {
            "plant": {
                "measure_every": 2,
                "disturbances": [
                    {"kind": "uniform", "at": "input", "bound": [0.3]},
                    {"kind": "sine", "at": "state", "amplitude": [0.1, 0.2], "hz": 0.7},
                ],
                "measurement": {"noise_bound": [0.01, 0.02]},
            }
        },
        {
            "plant": {"measure_every": 2, "measurement": {"C": [[1.0, 0.0]], "noise_std": [0.02]}},
            "observer": {"kind": "kalman", "input_std": [0.2], "initial_std": [1.0, 1.0]},
        },
    ],
    ids=["delay", "slow ticks", "fast ticks", "disturbed", "observed"],
)
@pytest.mark.parametrize("plant_hz", [20.0, 18.0])  # 18: no whole number of nanoseconds
def test_a_pattern_makes_the_run_of_the_machines(sections: dict[str, Any], plant_hz: float) -> None:
    sections = {**sections, "plant": sections.get("plant", {}) | {"rate_hz": plant_hz}}
    resolved = scenario_of({"policy": "mixed", "sigma": 0.05, "epsilon": 0.05}, **sections)
    certificate = quick_certificate(resolved)
    loop = SampledLoop(resolved)
    lost = tuple((np.random.default_rng(1).uniform(size=100) < 0.5).tolist())
    record, delivered = run(resolved, lost, loop.delay_ns)
    flow = SampledFlow(loop, Objective.STATE, certificate)
    sampled = run_sampled(flow, lambda event: event >= len(delivered) or delivered[event])
    rows = record["sensor_measurement"]
    expected_s = rows["t_ns"][rows["event"] >= 0] * 1e-9
    assert len(expected_s) > 4
    assert sampled.event_s == pytest.approx(expected_s.tolist())
    assert sampled.delivered == delivered
    x = record["plant_step"]["x"]
    assert sampled.value == pytest.approx(value_of(record, delivered, Objective.STATE, certificate))
    assert len(x) == loop.last + 1


def test_a_watchdog_that_may_trip_is_refused() -> None:
    sections = {"plant": {"watchdog": {"timeout_s": 0.06}}}
    with pytest.raises(CallerError, match="watchdog"):
        find_worst(scenario_of(EXAMPLES["decaying"], **sections), Objective.STATE)


@pytest.mark.parametrize("objective", [Objective.STATE, Objective.ERROR])
@pytest.mark.parametrize(
    "sections",
    [
        {"plant": {"disturbances": [{"kind": "uniform", "at": "input", "bound": [3.0]}]}},
        {"plant": {"measurement": {"noise_bound": [0.05, 0.0]}}},
        {
            "plant": {"measurement": {"C": [[1.0, 0.0]], "noise_bound": [0.3]}},
            "observer": {"kind": "luenberger", "poles_per_s": [-4.0, -5.0]},
        },
    ],
    ids=["disturbance", "noise", "observer"],
)
def test_the_found_signs_of_the_disturbances_are_the_worst_of_all(
    sections: dict[str, Any], objective: Objective
) -> None:
    """Events every 0.15 s, whatever is measured: so the worst signs are those of the responses."""
    periodic = {"policy": "periodic", "period_s": 0.15}
    resolved = scenario_of(periodic, horizon_s=0.35, network={"mansd": 0}, **sections)
    certificate = quick_certificate(resolved)
    flow = SampledFlow(SampledLoop(resolved), objective, certificate)
    push, noise = (np.abs(part) for part in flow.loop.disturbances)
    bounds = disturbance_bounds(resolved)
    assert bounds is not None
    worst = 0.0
    for signs in product((-1.0, 1.0), repeat=len(noise) if len(noise) else len(push)):
        sign = np.array(signs)[:, None]
        causes = (push, sign * bounds.noise) if len(noise) else (sign * bounds.columns.T, noise)
        run = run_sampled(replace(flow, loop=flow.loop.with_disturbances(*causes)), lambda event: True)
        worst = max(worst, run.value)
    search_result = find_worst(resolved, objective)
    assert search_result.value == pytest.approx(worst, rel=1e-9)
    assert not search_result.exact


@pytest.mark.sanitized
def test_disturbances_for_too_few_steps_are_refused() -> None:
    """The core checks what Python hands to it."""
    loop = SampledLoop(scenario_of(EXAMPLES["mixed"]))
    runs, ones = loop.start(), np.ones(loop.last + 1)
    short = loop.with_disturbances(np.zeros((0, 2)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="end before the last step"):
        short.follow(runs, Scales(loop.weight, ones, ones), np.array([loop.last]))
