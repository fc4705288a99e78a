"""The conditions of a run, read in any batches: by the monitor during it, and after it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.claims.run_certificates import certificates_under
from cosim.analysis.summary.summary_model import ClaimVerdict
from cosim.output.claim_words import claim_reason
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NO_SEQUENCE,
    OWNER,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.roles import LOOP_ROLES
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import allowed_conditions, nominal_conditions
from tests.cosim.analysis.claims.conftest import Make, event_s, network_of, without
from tests.cosim.record.changed_records import changed
from tests.cosim.simulation.outage import LosingMachine, simulate_with, with_outage

Batches = Iterator[tuple[str, Rows] | None]
"""A table and some of its rows; None where the result so far is queried."""
IN_WINDOW = {"kind": "at_most", "losses": 2, "window": 6}
RECOVERY = {"kind": "recovery", "deliveries": 2}
NO_DELAY = network_of(lambda n: 0)


def hostile(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    lost, late_ms, often = rng.uniform(0, 0.7), int(rng.choice([0, 10, 80, 400])), rng.uniform()

    def decide(number: int) -> int | None:
        if rng.uniform() < lost:
            return None
        return int(rng.integers(0, late_ms + 1)) if rng.uniform() < often else 0

    return network_of(decide)


@st.composite
def scenarios(draw: st.DrawFn, make: Make) -> Scenario:
    watchdog = {"policy": draw(st.sampled_from(["hold", "zero", "model"])), "timeout_s": 0.01}
    rate_hz = draw(st.sampled_from([100.0, 200.0]))
    return make(
        horizon_s=1.0, trigger={"beta": draw(st.sampled_from([1e-6, 1e-3]))},
        plant={"rate_hz": rate_hz, "watchdog": watchdog},
        controller={"phase": draw(st.sampled_from([0.0, 0.5])), "safe_input": [0.1]},
        network={
            "initial_sync": draw(st.sampled_from(["first_packet", "known_state"])),
            "constraints": draw(st.sampled_from([[], [IN_WINDOW], [IN_WINDOW, RECOVERY]])),
        },
    )  # fmt: skip


def damaged(record: RunRecord, seed: int) -> RunRecord:
    """A record with missing rows, or of a process that died."""
    rng = np.random.default_rng(seed)
    match int(rng.integers(0, 3)):
        case 1:
            role, end_ns = rng.choice(LOOP_ROLES), rng.uniform(0.2, 1) * 1e9
            own = [table for table in record.tables if OWNER[table] == role]
            return changed(record, {t: record[t][record[t]["now_ns"] < end_ns] for t in own})
        case 2:
            table = str(rng.choice([CONTROLLER_DELIVERY, SENSOR_MEASUREMENT, PLANT_ACTUATION]))
            there = rng.uniform(size=len(record[table])) > 0.1
            return changed(record, {table: record[table][there]})
    return record


def test_no_hostile_or_damaged_run_violates_a_bound(make: Make) -> None:
    """Where a run conforms its bounds hold, and everything is compared without an error."""
    verdicts: set[ClaimVerdict] = set()

    @settings(max_examples=25)
    @given(scenarios(make), st.integers(0, 2**32))
    def check(resolved: Scenario, seed: int) -> None:
        claims = RunClaims(damaged(simulate(resolved, hostile(seed)), seed))
        verdicts.update(claim.verdict for claim in claims.evaluate() if claim.is_certified)
        assert all(part.failure is not None or not part.until_s for part in claims.conformance())

    check()
    assert ClaimVerdict.ENDED in verdicts
    assert ClaimVerdict.VIOLATED not in verdicts


# --- where a run is not one of its document ------------------------------------------------------


def losing(*numbers: int, constraint: dict[str, Any]) -> Callable[[Make], RunRecord]:
    return lambda make: simulate(
        make(network={"constraints": [constraint]}),
        network_of(lambda n: None if n in numbers else 0),
    )


def deaf(role: str, first: int, last: int) -> Callable[[Make], RunRecord]:
    """A run in which a process does not receive the messages ``first`` to ``last`` − 1."""
    return lambda make: simulate_with(
        make(), role, lambda machine: LosingMachine(machine, lambda n: not first <= n < last), NO_DELAY
    )


def delayed(decide: Callable[[int], int | None]) -> Callable[[Make], RunRecord]:
    return lambda make: simulate(make(), network_of(decide))


def watchdog(policy: str) -> Callable[[Make], RunRecord]:
    """An input may be 35 ms old; the watchdog acts after 20 ms."""
    settings = {"watchdog": {"policy": policy, "timeout_s": 0.02}}
    return lambda make: with_outage(make(plant=settings, certificate={"late_periods": 2}), 2.0, 2.3)


def safe_input(make: Make) -> RunRecord:
    """The start may take as long as the network's delay, and there must be no input until then."""
    late = {"impairments": [{"kind": "delay", "delay_s": 0.1}]}
    return simulate(make(controller={"safe_input": [0.5]}, network=late))


@pytest.mark.parametrize(
    ("violate", "at", "reason"),
    [
        (deaf("controller", 10, 14), 12, "3 packets were lost in a row, at most 2 are allowed"),
        (deaf("netem", 10, 14), 12, "3 packets were lost in a row, at most 2 are allowed"),
        (deaf("sensor", 100, 103), 0.99, "a measurement is missing"),
        (watchdog("zero"), 2.02, "the applied input is none that the document allows; it was "),
        (safe_input, 0.01, ""),
    ],
)  # fmt: skip
def test_claims_end_where_the_run_leaves_its_document_and_say_why(
    violate: Callable[[Make], RunRecord], at: float, reason: str, make: Make
) -> None:
    """``at`` is a time, or the number of an event."""
    record = violate(make)
    when_s = event_s(record, at) if isinstance(at, int) else at
    checked = RunClaims(record)
    claims = [claim for claim in checked.evaluate() if claim.source == "certificate"]
    assert {claim.verdict for claim in claims} == {ClaimVerdict.ENDED}
    for claim in claims:
        assert claim.since_s == pytest.approx(when_s, abs=0.011)
        assert claim_reason(claim, checked.conformance()).startswith(reason)


def test_a_watchdog_with_the_controllers_model_is_in_the_document(make: Make) -> None:
    """Its input is the one of the controller's model, so the bounds hold."""
    claims = RunClaims(watchdog("model")(make))
    assert {c.verdict for c in claims.evaluate() if c.source == "certificate"} == {ClaimVerdict.HELD}


@pytest.mark.parametrize(
    ("violate", "time", "least_s"),
    [
        (delayed(lambda n: 33 if n == 7 else 0), "delay_s", 0.033),
        (lambda make: with_outage(make(), 2.0, 2.05), "hold_s", 0.05),
        (delayed(lambda n: 500 if n < 2 else 0), "start_s", 0.05),
    ],
)  # fmt: skip
def test_a_late_run_has_the_certificate_of_its_lateness(
    violate: Callable[[Make], RunRecord], time: str, least_s: float, make: Make
) -> None:
    record = violate(make)
    assert (read_conditions(record).summary()[time] or 0.0) > getattr(
        allowed_conditions(record.scenario), time
    )
    claims = RunClaims(record)
    assert (covered := claims.certified_for) is not None
    assert least_s <= getattr(covered, time) == claims.largest_observed[time]
    assert {claim.verdict for claim in claims.evaluate() if claim.source in ("certificate", "(I1)")} == {
        ClaimVerdict.HELD
    }


@pytest.mark.parametrize(
    ("violate", "why"),
    [
        (delayed(lambda n: 10_000 if n >= 7 else 0), "packets were lost in a row, at most 2 are allowed"),
        (lambda make: with_outage(make(), 2.0, 2.3), "the applied input is none that the document allows"),
    ],
)  # fmt: skip
def test_claims_about_a_run_that_is_later_than_any_certificate_covers_end_there(
    violate: Callable[[Make], RunRecord], why: str, make: Make
) -> None:
    record = violate(make)
    claims = RunClaims(record)
    assert claims.certified_for is None
    (reason,) = {
        claim_reason(claim, claims.conformance())
        for claim in claims.evaluate()
        if claim.source == "certificate"
    }
    assert why in reason
    largest = claims.evidence.observed.widen(allowed_conditions(record.scenario))
    (beyond,) = certificates_under(largest, record.scenario)
    assert not beyond.certificate.exists


# --- the conditions that a run has met ------------------------------------------------------------


PERIODS_NS = [1_000_000, 2_000_000, 3_000_000, 5_000_000, 7_000_000, 2_020_000, 13_370_000]


def busy(make: Make, step_ns: int, tick_ns: int, every: int, phase: float, sync: str) -> Scenario:
    """Almost every measurement is an event."""
    return make(
        horizon_s=0.6,
        plant={"rate_hz": 1e9 / step_ns, "measure_every": every},
        controller={"rate_hz": 1e9 / tick_ns, "phase": phase},
        trigger={"beta": 1e-12},
        network={"initial_sync": sync},
    )


def test_a_simulated_run_keeps_to_its_own_schedule_whatever_the_rates(make: Make) -> None:
    @settings(max_examples=20)
    @given(
        st.sampled_from(PERIODS_NS), st.sampled_from(PERIODS_NS), st.integers(1, 4),
        st.sampled_from([0.0, 0.1, 0.5, 0.99]) | st.floats(0, 0.999),
        st.sampled_from(["first_packet", "known_state"]),
    )  # fmt: skip
    def check(step_ns: int, tick_ns: int, every: int, phase: float, sync: str) -> None:
        resolved = busy(make, step_ns, tick_ns, every, phase, sync)
        observed, nominal = read_conditions(simulate(resolved)), nominal_conditions(resolved, 0)
        assert observed.first_broken_rule(nominal) is None
        assert observed.widen(nominal) == nominal

    check()


@pytest.mark.parametrize(
    ("step_ns", "tick_ns", "every", "phase"),
    [
        (2_000_000, 2_000_000, 1, 0.5),  # the demo's rates
        (2_000_000, 3_000_000, 1, 0.0),
        (5_000_000, 7_000_000, 3, 0.5),
        (4_000_000, 5_000_000, 2, 0.0168),
        (7_000_000, 2_000_000, 1, 0.9),
        (2_000_000, 2_020_000, 1, 0.3),
    ],
)
def test_the_worst_case_of_a_schedule_occurs(
    step_ns: int, tick_ns: int, every: int, phase: float, make: Make
) -> None:
    """The assumed delays and ages occur exactly, to the nanosecond."""
    resolved = busy(make, step_ns, tick_ns, every, phase, "first_packet")
    observed, nominal = read_conditions(simulate(resolved)).summary(), nominal_conditions(resolved, 0)
    for name in ("sampling_s", "delay_s", "hold_s", "lead_s", "start_s"):
        assert observed[name] == pytest.approx(getattr(nominal, name), abs=1e-12), name


def test_every_table_may_be_empty(run: RunRecord) -> None:
    empty = without(run, "plant", "sensor", "netem", "controller")
    conditions = read_conditions(empty)
    assert set(conditions.summary().values()) == {None}
    step = np.zeros(1, run[PLANT_STEP].dtype)
    step["actuation"] = NO_SEQUENCE
    assert read_conditions(changed(empty, {PLANT_STEP: step})).start_s == np.inf


# --- actuations that cross the network ------------------------------------------------------------


SCENARIOS = Path(__file__).parents[4] / "scenarios"
WORST = 'loss={model="worst_case"}'
RANDOM = 'loss={model="bernoulli", probability=0.4}'
DELAY = 'impairments=[{kind="delay", delay_s=0.013}]'
JITTER = 'impairments=[{kind="delay", delay_s=0.02, jitter_s=0.02}]'


def actuated(actuation: str, *more: str) -> Scenario:
    path = SCENARIOS / "lane_following.toml"
    base = ["horizon_s=3", "trigger.beta=0.05", f"network.actuation={{{actuation}}}"]
    return resolve(load(path, [*base, *more]))


@pytest.mark.parametrize("predictions", [1, 4])
@pytest.mark.parametrize(
    ("actuation", "reached"),
    [
        (f"mansd=0, {RANDOM}", True), (f"mansd=1, {WORST}", True), (f"mansd=3, {WORST}", True),
        (f"mansd=3, {RANDOM}, {DELAY}", False), (f"mansd=2, {RANDOM}, {JITTER}", False),
    ],
)  # fmt: skip
def test_no_run_leaves_the_conditions_of_its_schedule_and_some_reach_them(
    actuation: str, reached: bool, predictions: int
) -> None:
    rates = ("plant.rate_hz=100", "controller.rate_hz=50", "controller.phase=0.3")
    run = actuated(actuation, f"controller.predictions={predictions}", *rates)
    allowed, observed = nominal_conditions(run, 0), read_conditions(simulate(run)).summary()
    for name in ("delay_s", "hold_s", "start_s"):
        assert observed[name] is not None
        assert observed[name] <= getattr(allowed, name) + 1e-9, name  # type: ignore[operator]
    if reached and predictions == 1:
        assert observed["hold_s"] == pytest.approx(allowed.hold_s, abs=1e-9)
