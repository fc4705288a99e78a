"""The reference loop of a scenario: its settings, and what happened by chance in a recorded run."""

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np

from netem.core.random_streams import normals, uniforms
from noack.core.references import ReferenceSegment
from noack.disturbances.disturbance_settings import SignalSource
from noack.scenario.resolution import loop_of, reference_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_checks import with_settings
from tests.oracles.trigger_rules import Array, Rule
from tests.oracles.whole_loop import Chance, Settings, held_input


def why_not(scenario: Scenario) -> str | None:
    """Return why the reference loop cannot run a scenario; None if it can."""
    if scenario.loops is not None:
        return "several loops"
    if not scenario.coverage.is_linear:
        return f"the plant {scenario.plant.system.kind} is not linear"
    if not scenario.controller.is_linear:
        return "a user's controller"
    return "a user's trigger" if scenario.trigger.policy == "python" else None


def _period_ns(rate_hz: float) -> Fraction:
    """Return a period that is a whole number of nanoseconds, or that of a rate with few digits."""
    whole_ns = round(1e9 / rate_hz)
    is_whole = abs(1e9 / whole_ns - rate_hz) <= 1e-12 * rate_hz
    return Fraction(whole_ns) if is_whole else 10**9 / Fraction(rate_hz).limit_denominator(2000)


def settings_of(scenario: Scenario) -> Settings:
    """Return the settings of a resolved scenario."""
    loop, timing = loop_of(scenario), scenario.timing
    known = scenario.network.initial_sync == "known_state"
    in_force = [(0, scenario)]
    for change in scenario.changes:
        changed = with_settings(in_force[-1][1], change.set)
        in_force.append((round(change.at_s * 1e9), changed))
    C, safe_input = scenario.plant.measurement.C, scenario.controller.safe_input
    return Settings(
        A=loop.A, B=loop.B, A_model=loop.A_model, B_model=loop.B_model, K=loop.K,
        H=loop.A_model + loop.B_model @ loop.K if scenario.mode == "model" else 0 * loop.A,
        C=np.eye(loop.n) if C is None else np.array(C),
        x0=np.array(scenario.plant.initial_state), known_x0=_known_x0(scenario) if known else None,
        plant_period_ns=_period_ns(scenario.plant.rate_hz), measure_every=scenario.plant.measure_every,
        controller_period_ns=_period_ns(scenario.controller.rate_hz),
        controller_phase_ns=timing.controller_phase_ns, horizon_ns=timing.horizon_ns,
        rules=[(t_ns, rule_of(scenario_then)) for t_ns, scenario_then in in_force],
        references=_references(scenario, in_force),
        knows_references=scenario.controller.reference is not None,
        safe_input=np.zeros(loop.m) if safe_input is None else np.array(safe_input),
        predictions=scenario.controller.predictions,
        update_timeout_ns=np.rint(1e9 * (scenario.controller.update_timeout_s or np.inf)),
        timeout_input=scenario.controller.timeout_input,
        watchdog=scenario.plant.watchdog.policy,
        watchdog_timeout_ns=timing.actuation_timeout_ns,
        observer=None if scenario.observer is None else observer_of(scenario),
        actuations_cross=scenario.network.actuation is not None,
        acknowledgement_timeout_ns=(
            timing.acknowledgement_timeout_ns if scenario.network.protocol == "ack" else None
        ),
    )  # fmt: skip


def _known_x0(scenario: Scenario) -> Array:
    """Return x(0) without the loads, which nobody knows."""
    x = np.array(scenario.plant.initial_state)
    return np.where(np.arange(len(x)) < len(x) - scenario.model.load_states, x, 0.0)


def rule_of(scenario: Scenario) -> Rule:
    """Return the table of a scenario's trigger."""
    rule: Rule = scenario.trigger.model_dump(exclude_none=True)
    return rule


def _references(
    scenario: Scenario, in_force: Sequence[tuple[int, Scenario]]
) -> list[tuple[int, Callable[[int], Array]]]:
    """Return [x_r, u_r] by time: the segments of a reference, or the set-points in force."""
    if scenario.controller.reference is None:
        return [(t_ns, _at_rest(scenario_then)) for t_ns, scenario_then in in_force]
    segments = reference_of(scenario).segments
    return [(segment.begin_ns, partial(_follow, segment)) for segment in segments]


def _at_rest(scenario: Scenario) -> Callable[[int], Array]:
    """Return a set-point, and the smallest input with Âx_r + B̂u_r = 0, at all times."""
    A, B = (np.array(matrix) for matrix in scenario.model.matrices)
    x_r = np.array(scenario.controller.setpoint or np.zeros(len(A)))
    both = np.concatenate([x_r, -np.linalg.pinv(B) @ A @ x_r])
    return lambda _: both


def _follow(segment: ReferenceSegment, t_ns: int) -> Array:
    return segment.at((t_ns - segment.begin_ns) * 1e-9)


def observer_of(scenario: Scenario) -> Mapping[str, Array]:
    """Return the first estimate, and L or the covariances of a filter, as docs/scenarios.md says.

    The held noise of a plant step has the covariance diag(std²) of the state or the input.
    """
    observer: Any = scenario.observer
    plant, (n, m) = scenario.plant, scenario.model.dimensions
    known = scenario.network.initial_sync == "known_state"
    x = _known_x0(scenario) if known else np.zeros(n)
    if observer.initial_estimate is not None:
        x = np.array(observer.initial_estimate)
    if observer.kind == "luenberger":
        first = observer.gain if observer.first_gain is None else observer.first_gain
        return {"x": x, "L": np.array(observer.gain), "first_L": np.array(first)}
    variances = {"state": np.zeros(n), "input": np.zeros(m)}
    for disturbance in plant.disturbances:
        if disturbance.kind == "gaussian":
            variances[disturbance.at] += np.square(disturbance.std)
        if disturbance.kind == "uniform":
            variances[disturbance.at] += np.square(disturbance.bound) / 3
    noise = np.square(plant.measurement.noise_std or 0.0)
    noise = noise + np.square(plant.measurement.noise_bound or 0.0) / 3
    A, B = (np.array(matrix) for matrix in scenario.model.matrices)
    _, both = held_input(A, np.hstack([np.eye(n), B]), _period_ns(scenario.plant.rate_hz))
    process = np.concatenate([
        variances[at] if std is None else np.square(std)
        for at, std in (("state", observer.process_std), ("input", observer.input_std))
    ])  # fmt: skip
    Q = both @ np.diag(process) @ both.T if observer.Q is None else np.array(observer.Q)
    R = np.diag(noise if observer.noise_std is None else np.square(observer.noise_std))
    if observer.R is not None:
        R = np.array(observer.R)
    stated = {} if observer.gains is None else {"gains": np.array(observer.gains)}
    return {"x": x, "P": np.diag(np.square(observer.initial_std)), "Q": Q, "R": R} | stated


def chance_of(scenario: Scenario, packets: Any) -> Chance:
    """Return disturbances and noise of a resolved scenario, and the recorded fates of packets.

    ``packets`` has the columns of the table netem_packet.
    """
    n, m = scenario.model.dimensions
    steps = range(scenario.timing.last_step + 1)
    pushes = {"state": np.zeros((len(steps), n)), "input": np.zeros((len(steps), m))}
    for number, disturbance in enumerate(scenario.plant.disturbances):
        name = ("plant", "disturbance", str(number))
        source = SignalSource(scenario.timing.plant_period, scenario.seeds.disturbance, name)
        pushes[disturbance.at] += disturbance.signal(steps, source)
    v = _noise(scenario, steps)
    return Chance(
        d=pushes["input"].__getitem__,
        w=pushes["state"].__getitem__,
        noise=v.__getitem__,
        forward=arrivals(packets, 0),
        reverse=arrivals(packets, 1),
    )


def _noise(scenario: Scenario, numbers: range) -> Array:
    """Return v of each measurement, (k, p)."""
    measurement, seed = scenario.plant.measurement, scenario.seeds.noise
    p = len(measurement.C or scenario.plant.initial_state)
    normal, uniform = (
        table(seed, "plant", "measurement", part, rows=numbers, width=p)
        for part, table in (("normal", normals), ("uniform", uniforms))
    )
    std, bound = measurement.noise_std or 0.0, measurement.noise_bound or 0.0
    return np.multiply(std, normal) + np.multiply(bound, 2 * uniform - 1)


def arrivals(packets: Any, flow: int) -> Callable[[int], Sequence[int]]:
    """Return when each packet of a flow arrives; a packet that is not on record is lost.

    A receiver rejects a packet with a flipped bit.
    """
    rows = packets[(packets["flow"] == flow) & (packets["bit"] < 0)]
    arriving = {
        packet: [t_ns for t_ns in times if t_ns >= 0]
        for packet, *times in rows[["sequence", "release_ns", "copy_ns"]].tolist()
    }
    return lambda packet: arriving.get(packet, [])
