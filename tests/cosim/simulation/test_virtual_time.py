"""Simulated runs: violations, long runs, a controller that stands still, acknowledgements."""

from functools import cache
from pathlib import Path
from typing import Any

import pytest

from cosim.analysis.certificates import Certificates
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.fidelity import IncomparableError, recorded_loop
from cosim.analysis.replay import replay
from cosim.analysis.summary.run_summary import summarise
from cosim.analysis.summary.summary_model import ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import continuous_loop_of
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.protocol.record_tables import (
    ACKNOWLEDGEMENTS,
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    UPDATES,
    Fate,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.assumptions import AssumptionStatus, assumptions
from tests.cosim.live.outage import CASES, POLICIES, at_the_end, with_outage
from tests.helpers.shipped import resolved
from tests.oracles.link import Link


@pytest.fixture
def busy_content(content: dict[str, Any]) -> dict[str, Any]:
    """Dozens of events, half of them lost, and a plant that differs from the model."""
    mismatch = {"draw": "uniform", "uncertainty_A": [[0.0, 0.0], [0.5, 0.5]]}
    content["horizon_s"] = 4.0
    content["plant"] |= {"rate_hz": 100.0} | mismatch
    content["controller"] = {"rate_hz": 100.0}
    content["trigger"]["beta"] = 0.01
    return content


def test_the_controller_reports_a_violated_assumption(busy_content: dict[str, Any]) -> None:
    busy_content["network"] |= {"mansd": 0, "enforce_mansd": False}
    record = simulate(resolve(validate(busy_content, "test")))
    assert record.notices
    assert {notice["process"] for notice in record.notices} == {"controller"}
    assert {notice["level"] for notice in record.notices} == {"violation"}
    deliveries = record[CONTROLLER_DELIVERY]
    long_gaps = deliveries[deliveries["dropouts"] > 0]
    violations = summarise(record, 0, "horizon").to_json()["assumption_violations"]
    assert len(violations) == len(long_gaps) > 0
    for violation, gap in zip(violations, long_gaps, strict=True):
        assert violation["t_s"] == pytest.approx(gap["t_ns"] * 1e-9)
        assert violation["process"] == "controller"
        assert f"{gap['dropouts']} successive dropouts" in violation["what"]


def test_a_violation_without_a_later_delivery_is_reported(busy_content: dict[str, Any]) -> None:
    loss = {"model": "worst_case"}
    busy_content["network"] = {"mansd": 2, "enforce_mansd": False, "loss": loss}
    record = simulate(resolve(validate(busy_content, "test")))
    summary = summarise(record, 0, "horizon").to_json()
    (violation,) = summary["assumption_violations"]
    events = record[SENSOR_MEASUREMENT]
    event_ns = events["t_ns"][events["event"] >= 0]
    # t_0 is delivered; two losses are allowed
    assert violation["t_s"] == pytest.approx(event_ns[3] * 1e-9)
    assert summary["longest_loss_burst"] == len(event_ns) - 1 > 2


def test_each_packet_of_a_long_run_is_recorded_once_and_progress_is_reported(
    busy_content: dict[str, Any],
) -> None:
    """The network's memory for rows is full three times."""
    busy_content["trigger"] = {"policy": "periodic", "period_s": 0.01}
    busy_content["horizon_s"] = 150.0
    reported_ns: list[int] = []
    record = simulate(resolve(validate(busy_content, "test")), progress=reported_ns.append)
    assert record[NETEM_PACKET]["input"].tolist() == list(range(15_001))
    assert len(reported_ns) > 2
    assert reported_ns == sorted(reported_ns)
    assert 0 <= reported_ns[0] < reported_ns[-1] <= record.scenario.timing.horizon_ns


# --- a controller that stands still ---------------------------------------------------------------


DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module", params=["hold", "zero", "model"])
def run(request: pytest.FixtureRequest) -> RunRecord:
    """The controller stands still from 1 s to 1.4 s; its last tick before that is at 0.999 s."""
    changes = [f"plant.watchdog.policy={request.param}", "horizon_s=2"]
    return with_outage(resolved("lane_following", *changes), 1.0, 1.4)


def test_the_beginning_and_end_of_a_trip_are_reported_and_replayed(run: RunRecord) -> None:
    trips = [(one["t_ns"], one["process"]) for one in run.notices if one["level"] == "watchdog"]
    assert trips == [(1_100_000_000, "plant"), (1_402_000_000, "plant")]
    policy = run.scenario.plant.watchdog.policy
    assert summarise(run, 0, "horizon").to_json()["watchdog"] == {
        "policy": policy, "timeout_s": pytest.approx(0.1), "trips": 1,
        "first_s": pytest.approx(1.1), "total_s": pytest.approx(0.302),
    }  # fmt: skip
    assert replay(run).bit_exact
    if policy == "hold":
        recorded_loop(run)
        return
    with pytest.raises(IncomparableError, match="no watchdog and no safe input"):
        recorded_loop(run)


def test_the_table_in_the_documentation_is_the_simulated_one() -> None:
    """One number is simulated again; `python -m tests.cosim.live.outage` prints all rows."""
    lines = (DOCS / "network.md").read_text().splitlines()
    rows = [
        [line for line in lines if line.startswith(f"| `{name}`, `{mode}` | {lasts_s:g} s |")]
        for name, mode, lasts_s in CASES
    ]
    assert [len(row) for row in rows] == [1] * len(CASES)
    name, mode, lasts_s = CASES[4]
    held = rows[4][0].split(" | ")[2 + POLICIES.index("hold") + 1]
    assert held == f"{at_the_end(name, mode, 'hold', lasts_s):.2g}"


# --- acknowledgements (the baseline) --------------------------------------------------------------


COARSE = ("plant.rate_hz=100", "controller.rate_hz=100", "horizon_s=6")


def acknowledged(*overrides: str) -> Scenario:
    return resolved("lane_acknowledged", *COARSE, *overrides)


def plain(*overrides: str) -> Scenario:
    return resolved("lane_following", *COARSE, *overrides)


@cache
def run_of(*overrides: str) -> RunRecord:
    return simulate(acknowledged(*overrides))


def fates(record: RunRecord, flow: int) -> list[int]:
    rows = record[NETEM_PACKET]
    found: list[int] = rows["fate"][rows["flow"] == flow].tolist()
    return found


def test_each_direction_has_its_own_random_stream() -> None:
    record, other = run_of(), simulate(plain())
    count = min(len(fates(record, UPDATES)), len(fates(other, UPDATES)))
    assert count > 5
    assert fates(record, UPDATES)[:count] == fates(other, UPDATES)[:count]
    settings = LinkSettings(impairments=(LossOf(loss=BernoulliLoss(probability=0.5)),))
    link = Link(settings, record.scenario.seeds.loss, "acknowledgement")
    answers = fates(record, ACKNOWLEDGEMENTS)
    expected = [Fate(link.decide(ACKNOWLEDGEMENTS, 48, 0).fate) for _ in answers]
    assert answers == expected
    assert {Fate.DELIVERED, Fate.DROPPED} == set(answers)


def test_the_summary_counts_acknowledgements() -> None:
    record = run_of()
    summary = summarise(record, 0, "horizon").to_json()
    found = summary["acknowledgements"]
    assert found["sent"] == summary["deliveries"] == len(record[CONTROLLER_DELIVERY])
    assert found["received"] == len(record[SENSOR_ACKNOWLEDGEMENT])
    assert found["lost"] > 0
    assert 0 <= found["sent"] - found["lost"] - found["received"] <= 2  # in flight at the end
    assert summary["unintended_losses"] == summary["missing_samples"] == 0
    assert summary["identity_residual_max"] is None
    assert summarise(simulate(plain()), 0, "horizon").acknowledgements is None


def test_the_baseline_has_no_claims() -> None:
    record = run_of()
    (claim,) = ClaimEvaluation(record).judge()
    assert claim.verdict is ClaimVerdict.VOID
    assert 'network.protocol = "ack"' in claim.why
    assert ClaimEvaluation(record).envelopes() == []
    (assumption,) = [a for a in assumptions(record.scenario) if "acknowledged" in a.what]
    assert assumption.verdict is AssumptionStatus.VIOLATED
    for refuse in (continuous_loop_of, lambda scenario: Certificates(scenario, 2)):
        with pytest.raises(CallerError, match=r'network\.protocol = "ack": x_s is reset'):
            refuse(record.scenario)
    with pytest.raises(CallerError, match=r"network\.acknowledgements.*there are none unless"):
        plain("network.acknowledgements.timeout_s=0.1")
    back = ("network.protocol=none", "network.acknowledgements.timeout_s=0.1")
    assert not plain(*back).protocol.acknowledges
