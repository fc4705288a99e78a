"""Loops whose clocks differ: a claim that is not void is not violated (docs/derivations.md).

The true time is the plant's. The controller and the network read clocks that are off by tens of
milliseconds and drift, and nobody corrects them. So all that a run's record shows of it are delays
and ages.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.replay import replay
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import allowed_conditions
from tests.cosim.analysis.claims.conftest import Make
from tests.cosim.simulation.shuttle import shuttled
from tests.machine_interface import Machine

MS = 1_000_000
PPB = 10**9


class OtherClock:
    """A machine that reads a clock with an offset and a drift; the loop goes on in true time."""

    def __init__(self, machine: Machine[Any], offset_ns: int, drift_ppb: int) -> None:
        self._machine, self._offset_ns, self._drift_ppb = machine, offset_ns, drift_ppb

    def _own_ns(self, true_ns: int) -> int:
        return true_ns + self._offset_ns + self._drift_ppb * true_ns // PPB

    def next_deadline_ns(self) -> int | None:
        due_ns = self._machine.next_deadline_ns()
        if due_ns is None:
            return None
        true_ns = (due_ns - self._offset_ns) * PPB // (PPB + self._drift_ppb)
        while self._own_ns(true_ns) < due_ns:
            true_ns += 1
        return max(true_ns, 0)  # the run begins at the true time 0

    def handle(self, message: Any, now_ns: int) -> Sequence[Any]:
        return self._machine.handle(message, self._own_ns(now_ns))

    def on_timer(self, now_ns: int) -> Sequence[Any]:
        return self._machine.on_timer(self._own_ns(now_ns))


def simulated(scenario: Scenario, clocks: dict[str, tuple[int, int]]) -> RunRecord:
    """Simulate with the offset in ns and the drift in ppb of the clock of each role."""
    wraps = {
        role: partial(OtherClock, offset_ns=at, drift_ppb=by) for role, (at, by) in clocks.items()
    }
    return shuttled(scenario, wraps=wraps)


def certified(record: RunRecord) -> dict[str, ClaimVerdict]:
    claims = ClaimEvaluation(record).judge()
    return {one.bound: one.verdict for one in claims if one.source == "certificate"}


@pytest.mark.parametrize("delay_s", [0.0, 0.01])
def test_every_claim_holds_whatever_the_clocks(make: Make, delay_s: float) -> None:
    """Offsets of up to 50 ms, drifts of up to 100 ppm; late runs have a certificate for that."""
    impairments = [{"kind": "delay", "delay_s": delay_s}] if delay_s else []
    rng, seen = np.random.default_rng(5), set()
    for number in range(20):
        scenario = make(
            horizon_s=3.0, certificate={"late_periods": number % 2 * 3},
            network={"impairments": impairments},
        )  # fmt: skip
        most_ns = int(rng.choice([5, 50])) * MS
        clocks = {
            name: (int(rng.integers(-most_ns, most_ns)), int(rng.integers(-100_000, 100_000)))
            for name in ("controller", "netem", "sensor")
        }
        record = simulated(scenario, clocks)
        claims = ClaimEvaluation(record)
        assert {*certified(record).values()} == {ClaimVerdict.HELD}, clocks
        seen.add(claims.certified_for is not None)
        assert replay(record).bit_exact
    assert seen == {True, False}


@pytest.mark.parametrize("offset_ns", [40 * MS, -40 * MS])
def test_a_clock_that_is_off_is_a_measured_age_of_the_input(make: Make, offset_ns: int) -> None:
    scenario = make(certificate={"late_periods": 0})
    record = simulated(scenario, {"controller": (offset_ns, 0)})
    found, exact = read_conditions(record), read_conditions(simulate(scenario))
    hold_s, exact_s = found.hold.largest(), exact.hold.largest()
    assert hold_s is not None
    assert exact_s is not None
    assert hold_s >= 0.04 - exact_s
    assert hold_s > allowed_conditions(scenario).hold_s
    assert (covered := ClaimEvaluation(record).certified_for) is not None
    assert covered.hold_s == hold_s
    assert {*certified(record).values()} == {ClaimVerdict.HELD}


def test_the_networks_and_the_sensors_clocks_enter_no_condition(make: Make) -> None:
    """Without a delay in the network, only ``now_ns`` of their rows differs."""
    scenario = make()
    exact = simulate(scenario)
    record = simulated(scenario, {"netem": (50 * MS, 100_000), "sensor": (-50 * MS, -100_000)})
    assert ClaimEvaluation(record).judge() == ClaimEvaluation(exact).judge()
    for found, expected in zip(
        read_conditions(record)[:5], read_conditions(exact)[:5], strict=True
    ):
        np.testing.assert_array_equal(found, expected)
