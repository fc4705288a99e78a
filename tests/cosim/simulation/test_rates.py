"""Rates whose periods are no whole number of nanoseconds: 30, 60, 90, 120, 144 Hz, 1/3 s."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import noack
from cosim.analysis.replay import replay
from cosim.simulation.virtual_time import simulate
from netem.core.periods import MOST_PARTS, period_of
from noack.scenario.resolution import resolve, resolved_loops
from noack.scenario.scenario_file import validate
from noack.trigger_policies.quadratic import QuadraticSettings
from plant_server.plant import plants_of
from tests.oracles.comparison import Comparison
from tests.oracles.random_scenarios import random_scenario

RATES = (3.0, 30.0, 60.0, 90.0, 120.0, 144.0, 30_000 / 1001)
LONGEST_S = 10**7


def at_rate(name: str, plant_hz: float, controller_hz: float, **settings: Any) -> noack.Scenario:
    rates = {"plant.rate_hz": plant_hz, "controller.rate_hz": controller_hz}
    return noack.load(name, {"horizon_s": 4.0, **rates, **settings})


def exact_times(rate_hz: float, count: int, first: int = 0) -> np.ndarray:
    rate = Fraction(rate_hz).limit_denominator(2000)
    return np.array([math.floor(k * 10**9 / rate + Fraction(1, 2)) for k in range(first, first + count)])


@pytest.mark.parametrize("rate_hz", RATES)
def test_no_step_drifts_within_the_longest_run(rate_hz: float) -> None:
    """In Python and in the core."""
    period = period_of(rate_hz)
    (loop,) = resolved_loops(at_rate("lane_following", rate_hz, rate_hz))
    machines = plants_of([loop])
    machine = machines.machines[0].machine
    machine.horizon_ns = LONGEST_S * 10**9
    rng, last = np.random.default_rng(1), int(LONGEST_S * rate_hz)
    steps = [0, 1, 2, 3, last - 1, last, *rng.integers(0, last, 200).tolist()]
    np.testing.assert_array_equal(
        period.times_ns(np.array(steps)), [int(exact_times(rate_hz, 1, k)[0]) for k in steps]
    )
    for k in steps:
        expected = int(exact_times(rate_hz, 1, k)[0])
        machine.step = k
        process = machines._new_process(1)
        assert period.time_ns(k) == process.heap[0].due_ns == expected
        assert period.last_until(expected) == k
        assert period.last_until(expected - 1) == k - 1 if k else True


def test_a_rate_with_many_digits_is_met_within_its_rounding() -> None:
    for rate_hz in np.random.default_rng(2).uniform(1, 10_000, 500).tolist():
        period = period_of(rate_hz)
        assert period.exact.denominator <= MOST_PARTS
        assert float(10**9 / period.exact) == pytest.approx(rate_hz, rel=1e-12)


def test_a_whole_period_stays_whole() -> None:
    for rate_hz in (500.0, 100.0, 64.0, 30.000000300000004, 59.99999880000002, 1e9 / 7_654_321, 1e-6):
        assert period_of(rate_hz).is_whole
        assert period_of(rate_hz).longest_ns == round(1e9 / rate_hz)


@pytest.mark.parametrize(
    "number", [pytest.param(number, marks=pytest.mark.deep if number >= 3 else ()) for number in range(12)]
)
def test_random_scenarios_run_as_the_reference_loop(number: int) -> None:
    content = random_scenario(number)
    rng = np.random.default_rng(number)
    for table in ("plant", "controller"):
        content[table]["rate_hz"] = float(rng.choice([300, 600, 700, 900, 1200, 1440]))
    if content["trigger"]["policy"] == "quadratic":
        content["plant"]["measure_every"], content["trigger"]["period_s"] = 1, 0.01
    record = simulate(resolve(validate(content, "random")))
    Comparison(record)
    assert replay(record).bit_exact


def test_a_period_of_whole_steps_is_kept_at_each_rate() -> None:
    for rate_hz, steps in ((30.0, 3), (60.0, 6), (90.0, 9), (120.0, 12), (30.0, 2), (90.0, 7)):
        trigger = {"policy": "periodic", "period_s": steps / rate_hz}
        record = simulate(resolve(at_rate("lane_following", rate_hz, rate_hz, trigger=trigger)))
        events = record.events()["t_ns"]
        np.testing.assert_array_equal(events, exact_times(rate_hz, len(events) * steps)[::steps])


def test_a_grid_that_is_no_whole_number_of_nanoseconds_is_refused() -> None:
    trigger = {**QuadraticSettings.example(4).content(), "period_s": 1 / 30}
    with pytest.raises(noack.NoackError, match=r"trigger.period_s.*: must be a whole number of nanoseconds"):
        at_rate("lane_following", 30.0, 30.0, trigger=trigger)


@pytest.mark.parametrize("rate_hz", [30.0, 144.0])
def test_claims_and_identity_hold(rate_hz: float) -> None:
    run = noack.simulate(at_rate("lane_following", rate_hz, rate_hz, horizon_s=8.0))
    (loop,) = run.summary.loops
    assert run.ok
    assert loop.identity_residual_max < 1e-12
    assert "violated" not in [claim.verdict for claim in loop.claims]
    assert loop.missing_samples == 0
    assert loop.uneven_periods == []
    if rate_hz > 100:
        assert loop.certified_for is None
        assert sum(claim.is_certified and claim.verdict == "held" for claim in loop.claims) > 4


@pytest.mark.parametrize("rate_hz", RATES)
@pytest.mark.parametrize("count", [1, 2, 5, 7])
def test_timeouts_and_phases_of_whole_steps_act_at_the_same_step_always(rate_hz: float, count: int) -> None:
    """An update of that age is too old, an actuation not yet; a first tick is not before its step."""
    times = exact_times(rate_hz, 1000)
    ages = times[count:] - times[:-count]
    rate = Fraction(rate_hz).limit_denominator(2000)
    seconds, phase = float(count / rate), {"controller.phase": 0.5}
    settings = {"controller.update_timeout_s": seconds, "plant.watchdog.timeout_s": seconds}
    timing = at_rate("lane_following", rate_hz, rate_hz, **settings).timing
    assert ages.max() - 1 <= timing.update_timeout_ns <= ages.min()
    assert ages.max() <= timing.actuation_timeout_ns <= ages.min() + 1
    slower = at_rate("lane_following", rate_hz, float(rate / (2 * count)), **phase).timing
    ticks = slower.controller_phase_ns + np.array([slower.controller_period.time_ns(k) for k in range(100)])
    steps = exact_times(rate_hz, 201 * count)[count :: 2 * count]
    assert set(ticks - steps) <= {0, 1}


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 144.0])
@pytest.mark.parametrize("predictions", [1, 2, 4])
def test_a_lost_actuation_is_used_for_as_many_steps_at_each_rate(rate_hz: float, predictions: int) -> None:
    """The watchdog's input is 0; with whole nanoseconds it is in use at the same steps."""

    def is_zero(rate_hz: float) -> list[bool]:
        settings = {
            "controller.predictions": predictions, "controller.phase": 0.0, "plant.watchdog.policy": "zero",
            "network.actuation.loss.probability": 0.6,
        }  # fmt: skip
        record = simulate(resolve(at_rate("lane_actuation_loss", rate_hz, rate_hz, **settings)))
        zeros: list[bool] = (record["plant_step"]["u"] == 0).all(axis=1).tolist()
        return zeros[:110]

    zeros = is_zero(rate_hz)
    assert zeros == is_zero(NEARBY[rate_hz])
    assert predictions > 3 or any(zeros[20:])


def test_an_acknowledgement_is_waited_for_as_many_steps_at_each_rate() -> None:
    def events(rate_hz: float, **settings: Any) -> list[int]:
        record = simulate(resolve(at_rate("lane_acknowledged", rate_hz, rate_hz, **settings)))
        t_s = record.events()["t_ns"] * 1e-9
        return np.rint(t_s[t_s < 3.9] * rate_hz).astype(int).tolist()

    for rate_hz, near_hz in NEARBY.items():
        waits = [events(hz, **{"network.acknowledgements.timeout_s": 2 / hz}) for hz in (rate_hz, near_hz)]
        assert waits[0] == waits[1]
        assert 2 in np.diff(waits[0])


NEARBY = {30.0: 30.000000300000004, 60.0: 59.99999880000002, 90.0: 89.99999991, 144.0: 1e9 / 6_944_444}
