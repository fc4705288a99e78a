"""The loops that tests of the checker are about, and numbers of their proofs.

Most are a double integrator under a decaying threshold, with one thing changed; `scalar` and what follows
from it has one state, and closed forms.
"""

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from flint import arb, fmpq
from scipy.linalg import expm

from noack.core.balls import beside, identity, matrix, number, zeros
from noack.observers.observer_settings import observer_gain
from noack.proof.elaborate.loop import Loop, LoopObserver, Rule, Times
from noack.proof.elaborate.scenario import _squares, read_loop
from noack.proof.search.results import Proof
from tests.checker.runs import floats
from tests.helpers.resolved_tables import resolved_tables

IDEAL = Times(fmpq(0), fmpq(0), fmpq(0), fmpq(0), fmpq(0))
SCHEDULE = Times(fmpq(1, 100), fmpq(1, 100), fmpq(1, 50), fmpq(3, 100), fmpq(1, 50))


def changed(loop: Loop, **times: fmpq) -> Loop:
    """Return a loop with other times."""
    return loop._replace(times=loop.times._replace(**times))


def with_rule(loop: Loop, **rule: object) -> Loop:
    """Return a loop with other parts of its rule."""
    return loop._replace(rule=loop.rule._replace(**rule))  # type: ignore[arg-type]


def pushed(loop: Loop, size: float) -> Loop:
    """Return a double integrator with a disturbance of its input."""
    return loop._replace(pushes=matrix([[0.0], [1.0]]), sizes=(number(size),))


def bounds_of(proof: Proof) -> dict[str, float]:
    """Return the bounds at t = 0, of parts of different units as a root of squares."""
    sizes: dict[str, float] = {}
    for bound in proof.bounds:
        if not bound.from_start:
            continue
        size = math.hypot(float(bound.decaying.mid()), float(bound.constant.mid()))
        sizes[bound.output] = min(size, sizes.get(bound.output, math.inf))
    return sizes


# The double integrator.


def double_integrator(times: Times = SCHEDULE, *, level: float = 0.05, floor: float = 0.0) -> Loop:
    """Return a double integrator whose input is a tenth weaker than its model's, with two losses in a row."""
    A, B, K = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[-1.0, -1.4]]
    rule = Rule(matrix([[0, 0, 1, 0], [0, 0, 0, 1]]), zeros(0, 4), number(level), number(0.3), number(floor))
    return Loop(
        A=matrix(A),
        B=matrix([[0.0], [0.9]]),
        half_A=zeros(2, 2),
        half_B=zeros(2, 1),
        model_A=matrix(A),
        model_B=matrix(B),
        gain=matrix(K),
        weight=matrix([[1, 0], [0, 1]]),
        holds=False,
        start=matrix([[1.0], [0.0]]),
        rule=rule,
        pushes=zeros(2, 0),
        sizes=(),
        noise=zeros(2, 0),
        losses=2,
        times=times,
    )


def holding(level: float = 0.0, floor: float = 0.02) -> Loop:
    """Return a loop that holds its input, under ideal conditions."""
    return double_integrator(IDEAL, level=level, floor=floor)._replace(holds=True)


def relative(sigma: float) -> Loop:
    """Return a loop with the rule ‖e_s‖ > σ‖x‖."""
    return with_rule(
        double_integrator(IDEAL, level=0.0), negative=matrix([[sigma, 0, 0, 0], [0, sigma, 0, 0]])
    )


def early(level: float) -> Loop:
    """Return a loop whose first input acts before the first test, at which e_s may be above the threshold."""
    times = SCHEDULE._replace(delay=fmpq(1, 100), age=fmpq(1, 50), start=fmpq(1, 100))
    return double_integrator(times, level=level)


def noisy(loop: Loop, size: float = 0.003) -> Loop:
    """Return a loop with noise of each state."""
    return loop._replace(noise=identity(loop.n) * number(size))


NOISY = noisy(double_integrator(floor=0.03))


def noisy_at(index: int) -> Loop:
    """Return the noisy loop with noise of one state only."""
    columns = [[0.003 * (index == 0)], [0.003 * (index == 1)]]
    return NOISY._replace(noise=matrix(columns))


def undamped() -> Loop:
    """Return a loop without losses, whose error grows between tests by a disturbance."""
    return pushed(double_integrator(floor=0.05, level=0.0), 0.05)._replace(losses=0)


def until_due() -> Loop:
    """Return a loop with a deadline that comes before two events by the comparison are apart."""
    loop = with_rule(double_integrator(), always=True)
    return changed(loop, due=fmpq(1, 50))


HOLDS = double_integrator(floor=0.02, level=0.0)._replace(holds=True)
"""A loop that holds its input, under a schedule."""


# With an observer.

OBSERVED_OUTPUT = np.array([[1.0, 0.0]])


def observed(
    loop: Loop,
    start: tuple[float, float] = (-0.2, 0.1),
    noise: float = 0.001,
    poles: tuple[float, ...] = (-8, -10),
) -> Loop:
    """Return a loop whose sensor measures its first state, with noise, and estimates the second one."""
    A, C, period_s = floats(loop.model_A), OBSERVED_OUTPUT, float(arb(loop.times.sampling))
    L = observer_gain(expm(A * period_s), C, tuple(np.exp(np.array(poles) * period_s)))
    estimate = matrix([[value] for value in start])
    observer = LoopObserver((matrix(L.tolist()),), matrix(C.tolist()), estimate, loop.times.sampling)
    noise_columns = matrix([[noise]]) if noise else zeros(1, 0)
    return loop._replace(B=loop.model_B, noise=noise_columns, observer=observer)


OBSERVED = observed(double_integrator(floor=0.03)._replace(losses=1))


# Those that are changed by the hundred.


def with_a_box() -> Loop:
    """Return a loop with a floor, a box of plants, a disturbance and outputs."""
    return pushed(double_integrator(floor=0.02), 0.01)._replace(
        half_A=matrix([[0.0, 0.0], [0.01, 0.0]]),
        half_B=matrix([[0.0], [0.01]]),
        losses=1,
        outputs=matrix([[1.0, 0.0], [0.5, -2.0]]),
    )


def with_skew_noise() -> Loop:
    """Return a loop with noise, in one direction of its own and in one of another weight."""
    loop, W = double_integrator(floor=0.02), matrix([[1, 0], [0.1, 1]])
    noise = matrix([[0.003, 0.001], [0.0, 0.002]])
    return with_rule(loop, positive=beside(zeros(2, 2), W))._replace(noise=noise, weight=W, losses=1)


def with_later_events() -> Loop:
    """Return a loop in which two events may happen while an update is on its way, and two before any acts."""
    times = SCHEDULE._replace(delay=fmpq(25, 1000), start=fmpq(25, 1000))
    return double_integrator(times, level=0.012)._replace(losses=1)


# Of one state.


def scalar(losses: int = 2, times: Times = IDEAL, *, level: float = 0.1, floor: float = 0.0) -> Loop:
    """Return ẋ = x + 2u, u = −x: the closed loop and the model decay at 1/s."""
    loop, one = double_integrator(times), identity(1)
    return loop._replace(
        A=one, B=2 * one, half_A=zeros(1, 1), half_B=zeros(1, 1), model_A=one, model_B=2 * one,
        gain=-1 * one, weight=one, start=one, losses=losses, pushes=zeros(1, 0), noise=zeros(1, 0),
        rule=loop.rule._replace(
            positive=beside(zeros(1, 1), one), negative=zeros(0, 2),
            level=number(level), rate=number(0.25), floor=number(floor),
        ),
    )  # fmt: skip


NOISE = number(0.05) * identity(1)


def steady(losses: int, *, level: float = 0.0, disturbance: float = 0.05, times: Times = IDEAL) -> Loop:
    """Return ẋ = x + 2u + d, u = −0.505 x, and the same model: errors of lost updates nearly stay.

    The threshold is max(level e^{−0.005t}, 1).
    """
    loop = scalar(losses, times, level=level, floor=1.0)
    return with_rule(loop, rate=number(0.005))._replace(
        gain=number(-0.505) * identity(1), pushes=identity(1), sizes=(number(disturbance),)
    )


def drifting(times: Times = IDEAL) -> Loop:
    """Return ẋ = −x + 0.02 x_c + d, |d| ≤ 1: nearly all that moves e_s is d. An event needs |e_s| > 0.5."""
    loop, one = steady(0, disturbance=1.0, times=times), identity(1)
    return with_rule(loop, floor=number(0.5))._replace(A=-1 * one, model_A=-1 * one, gain=number(0.01) * one)


DRIFTING: dict[str, Loop] = {
    "a drift": drifting(),
    "a drift with noise": drifting()._replace(noise=NOISE),
    "a first event": drifting(IDEAL._replace(start=fmpq(1, 10))),
}
DISTURBED = scalar(0, SCHEDULE)._replace(pushes=identity(1), sizes=(number(0.1),))
DUE = changed(with_rule(DISTURBED, level=arb(0), floor=number(10.0), always=True), longest=fmpq(1, 20))
AREA = with_rule(DISTURBED, level=arb(0), floor=number(0.01), integrates=True)


def with_form(loop: Loop, Q: list[list[float]], epsilon: float = 0.0004) -> Loop:
    """Return a loop with the rule zᵀQz > ε."""
    positive, negative = _squares(matrix(Q))
    return with_rule(loop, positive=positive, negative=negative, level=arb(0), floor=number(epsilon).sqrt())


# Whose events come periodically.


def periodic(least: fmpq, most: fmpq, times: Times = SCHEDULE) -> Loop:
    """Return a double integrator whose events come periodically."""
    loop = with_rule(double_integrator(times), positive=zeros(0, 4), level=arb(0), rate=arb(0), floor=arb(0))
    return changed(loop, least_period=least, period=most)


PERIODIC: dict[str, Loop] = {
    "exact": periodic(fmpq(3, 10), fmpq(3, 10)),
    "short": periodic(fmpq(3, 200), fmpq(1, 50), SCHEDULE._replace(start=fmpq(1, 100)))._replace(losses=1),
}
"""Updates of the short one may be on their way for 20 ms, in which one more event may come."""


# Whose tests are an exact time apart.

DYNAMIC_RULE = {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5, "eta_0": 0.1}


def trigger_setting(rule: Mapping[str, object]) -> str:
    """Return the setting of a trigger."""
    text = json.dumps(rule).replace('": ', '" = ')
    return f"trigger={text}"


def of_scenario(name: str, *settings: str, ideal: bool = False) -> Loop:
    """Return the loop of a shipped scenario's own plant."""
    return read_loop(resolved_tables(name, *settings), box=False, ideal=ideal)


def dwelling(times: Times = SCHEDULE) -> Loop:
    """Return a double integrator that waits for five tests after an event."""
    loop = double_integrator(times, floor=0.02)
    return changed(loop, dwell=5 * loop.times.sampling)._replace(losses=1)


def dynamic() -> Loop:
    """Return a loop with Girard's rule, without losses and delays, tested every 20 ms."""
    loop, zero = of_scenario("double_integrator", trigger_setting(DYNAMIC_RULE), "network.mansd=0"), fmpq(0)
    step = fmpq(1, 50)
    return changed(loop, delay=zero, age=zero, start=zero, sampling=step, least_sampling=step)


def held() -> Loop:
    """Return Tabuada's example under Girard's rule, with its input held, tested every 6 ms, a test late."""
    step = fmpq(6, 1000)
    return of_scenario("tabuada_dynamic")._replace(times=Times(step, step, step, fmpq(0), step))


TESTED_APART: dict[str, Callable[[], Loop]] = {
    "held": held,
    "dwell": lambda: dwelling()._replace(losses=0),
    "dwell_a_loss": dwelling,
    "dynamic": dynamic,
    "switching": lambda: of_scenario("selivanov_switching"),
    "grid": lambda: of_scenario("reactor_petc", ideal=True),
}


# Loops and settings of shipped scenarios.

SERVO = "servo_reference"


def servo(*settings: str) -> dict[str, Any]:
    """Return the tables of the servo that follows a reference."""
    return resolved_tables(SERVO, *settings)


def loop_with(tables: dict[str, Any], *, box: bool = True, **times: fmpq) -> Loop:
    """Return the loop of some tables, with some times that are at least these."""
    return read_loop(tables, box=box, ideal=False, longer=times)


FILTERED_MASS = (
    "plant={initial_state=[1.0,0.0],rate_hz=100.0,measurement={C=[[1.0,0.0]],noise_bound=[0.0005]}}",
    'observer={kind="kalman",process_std=[0.0,2.0],noise_std=[0.01],initial_std=[0.02,0.2],initial_estimate=[0.99,0.01]}',
    "controller.rate_hz=100", "trigger.beta=0.1", "trigger.floor=0.05", "network.mansd=1",
)  # fmt: skip
"""A Kalman filter for the double integrator, with few gains until they are constant."""
