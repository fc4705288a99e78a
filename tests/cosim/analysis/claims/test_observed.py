"""The observed conditions of a run: from complete and from damaged records."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.summary_model import ClaimVerdict
from cosim.output.certificate_report import Certificates
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import nominal_conditions
from tests.cosim.analysis.claims.conftest import Make, network_of, without
from tests.cosim.record.changed_records import changed

PERIODS_NS = [1_000_000, 2_000_000, 3_000_000, 5_000_000, 7_000_000, 2_020_000, 13_370_000]


def violation_of(record: RunRecord) -> tuple[float, str]:
    found = read_conditions(record).first_violation(nominal_conditions(record.scenario, 0))
    assert found is not None
    return found


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
        record = simulate(resolved)
        assert read_conditions(record).first_violation(nominal_conditions(resolved, 0)) is None

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
    seen, assumed = read_conditions(simulate(resolved)).summary(), nominal_conditions(resolved, 0)
    for name in ("sampling_s", "delay_s", "hold_s", "start_s"):
        assert seen[name] == pytest.approx(getattr(assumed, name), abs=1e-12), name


# --- violations that test_assumption_monitor.py does not make -------------------------------------


def older_inputs(run: RunRecord, by: int) -> RunRecord:
    """Steps 200 to 202 apply inputs that are older by ``by`` steps."""
    steps = run[PLANT_STEP].copy()
    steps["actuation"][200:203] -= by
    return changed(run, {PLANT_STEP: steps})


def without_any_input(run: RunRecord) -> RunRecord:
    steps = run[PLANT_STEP].copy()
    steps["actuation"] = NO_SEQUENCE
    return changed(run, {PLANT_STEP: steps})


@pytest.mark.parametrize(
    ("damage", "when_s", "why"),
    [
        (lambda run: older_inputs(run, 3), 2.0, "an input was 0.045 s old, 0.015 s allowed"),
        # A plant that is 3.5 steps late latches an input computed for a later time.
        (lambda run: older_inputs(run, -4), 2.0, "an input was 0.035 s old, 0.015 s allowed"),
        (
            lambda run: changed(run, {SENSOR_MEASUREMENT: run[SENSOR_MEASUREMENT][:300]}), 2.99,
            "no measurement for 3.01 s, 0.01 s allowed",
        ),
        (without_any_input, 0.0, "the plant applied no input at all, the first within 0.0"),
    ],
)  # fmt: skip
def test_a_damaged_record_violates_a_condition_from_its_time_on(
    run: RunRecord, damage: Callable[[RunRecord], RunRecord], when_s: float, why: str
) -> None:
    found_s, found = violation_of(damage(run))
    assert found_s == pytest.approx(when_s)
    assert found.startswith(why)


def test_a_known_initial_state_starts_without_an_update(make: Make) -> None:
    network = network_of(lambda n: 500 if n < 3 else 0)
    known = simulate(make(network={"initial_sync": "known_state"}), network)
    assert read_conditions(known).start_s == pytest.approx(0.01)


def test_a_stale_update_is_not_lost_if_the_newer_one_arrived_in_time(make: Make) -> None:
    """The delay of every other update is just long enough for the next update to arrive first."""
    resolved = make()
    allowance_s = 0.4
    record = simulate(resolved, network_of(lambda n: 500 if n % 2 else 0))
    observed = read_conditions(record)
    taken = set(record[CONTROLLER_DELIVERY]["sequence"].tolist())
    delivered_out_of_order = [n for n in range(len(observed.losses.t_s) - 2) if n not in taken]
    assert delivered_out_of_order
    assert observed.losses.consecutive(0.0).largest() == 1
    assert observed.losses.consecutive(allowance_s).largest() == 0


# --- incomplete records ---------------------------------------------------------------------------


def test_inputs_of_unrecorded_ticks_have_the_largest_possible_age(run: RunRecord) -> None:
    ticks, inputs = run[CONTROLLER_STEP], run[PLANT_ACTUATION]
    gap = slice(300, 310)
    record = changed(run, {CONTROLLER_STEP: np.delete(ticks, gap)})
    # The plant's record has the times of the missing ticks.
    assert read_conditions(record).hold.largest() == pytest.approx(0.015)
    record = changed(record, {PLANT_ACTUATION: np.delete(inputs, gap)})
    when_s, why = violation_of(record)
    assert when_s == pytest.approx(3.01)
    assert "an input was" in why


def test_every_table_may_be_empty(run: RunRecord) -> None:
    empty = without(run, "plant", "sensor", "netem", "controller")
    found = read_conditions(empty)
    assert set(found.summary().values()) == {None}
    assert found.first_violation(nominal_conditions(run.scenario, 0)) is not None
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
@pytest.mark.parametrize("rates", [(100, 100, 0.5), (100, 50, 0.0), (500, 100, 0.3)])
def test_no_run_leaves_the_conditions_of_its_schedule_and_some_reach_them(
    actuation: str, reached: bool, predictions: int, rates: tuple[float, float, float]
) -> None:
    plant_hz, controller_hz, phase = rates
    run = actuated(
        actuation, f"controller.predictions={predictions}", f"plant.rate_hz={plant_hz}",
        f"controller.rate_hz={controller_hz}", f"controller.phase={phase}",
    )  # fmt: skip
    allowed, found = nominal_conditions(run, 0), read_conditions(simulate(run)).summary()
    for name in ("delay_s", "hold_s", "start_s"):
        assert found[name] is not None
        assert found[name] <= getattr(allowed, name) + 1e-9, name  # type: ignore[operator]
    if reached and predictions == 1:
        assert found["hold_s"] == pytest.approx(allowed.hold_s, abs=1e-9)


@pytest.mark.parametrize("predictions", [1, 4])
@pytest.mark.parametrize("policy", ["hold", "zero"])
@pytest.mark.parametrize("actuation", [f"mansd=3, {WORST}", f"mansd=3, {RANDOM}"])
def test_the_claims_of_a_run_are_judged_where_the_watchdog_stays_idle(
    actuation: str, policy: str, predictions: int
) -> None:
    run = actuated(
        actuation, f"controller.predictions={predictions}", f'plant.watchdog.policy="{policy}"'
    )
    verdicts = [claim.verdict for claim in ClaimEvaluation(simulate(run)).judge()]
    idle = policy == "hold" or predictions == 4
    assert run.coverage.is_certifiable == idle
    # (I1) and eq:LossEv3 need no certificate.
    assert len(verdicts) > 10 if idle else len(verdicts) == 3
    assert set(verdicts) == {ClaimVerdict.HELD}


def test_what_is_not_covered_is_refused_with_the_reason() -> None:
    for run, says in (
        (actuated(RANDOM), "the age of the applied input has no bound"),
        (actuated("mansd=1", 'plant.watchdog.policy="model"'), "use more controller.predictions"),
    ):
        with pytest.raises(CallerError, match=says):
            Certificates(run, 2)
    with pytest.raises(CallerError, match=r"network\.actuation"):
        actuated("mansd=1").coverage.require_exact()
