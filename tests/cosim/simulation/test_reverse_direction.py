"""Loops whose controller sends over the network: acknowledgements or actuations."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.certificates import Certificates
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.loop_statistics import from_controller, unintended_losses
from cosim.analysis.run_summary import summarise
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.run_events import packet_outcomes
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
    PLANT_ACTUATION,
    SENSOR_ACKNOWLEDGEMENT,
    UPDATES,
    Fate,
)
from noack.protocol.wire_format import Flow
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.assumptions import AssumptionStatus, assumptions
from tests.cosim.record.changed_records import changed
from tests.oracles.link import Link

SCENARIOS = Path(__file__).parents[3] / "scenarios"
COARSE = ("plant.rate_hz=100", "controller.rate_hz=100", "horizon_s=6")


def acknowledged(*overrides: str) -> Scenario:
    return resolve(load(SCENARIOS / "lane_acknowledged.toml", [*COARSE, *overrides]))


def plain(*overrides: str) -> Scenario:
    return resolve(load(SCENARIOS / "lane_following.toml", [*COARSE, *overrides]))


@cache
def run_of(*overrides: str) -> RunRecord:
    return simulate(acknowledged(*overrides))


def fates(record: RunRecord, flow: int) -> list[int]:
    rows = record[NETEM_PACKET]
    found: list[int] = rows["fate"][rows["flow"] == flow].tolist()
    return found


def test_the_default_timeout_covers_the_delays_of_both_directions() -> None:
    assert (
        acknowledged("network.acknowledgements={}").timing.acknowledgement_timeout_ns == 50_000_000
    )
    late = (
        'network.impairments=[{kind="delay", delay_s=0.02, jitter_s=0.01}]',
        'network.acknowledgements={impairments=[{kind="delay", delay_s=0.04}]}',
    )
    assert acknowledged(*late).timing.acknowledgement_timeout_ns == 120_000_000


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


def test_the_cap_of_the_reverse_direction_holds() -> None:
    back = 'network.acknowledgements={mansd=2, loss={model="worst_case"}}'
    found = fates(simulate(acknowledged(back)), ACKNOWLEDGEMENTS)
    assert len(found) >= 6
    assert [Fate(fate).effective for fate in found] == [k % 3 == 2 for k in range(len(found))]


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


# --- actuations over the network ------------------------------------------------------------------


MESSY = """{mansd=2, loss={model="bernoulli", probability=0.4}, impairments=[
 {kind="delay", delay_s=0.01, jitter_s=0.02}, {kind="duplicate", probability=0.3},
 {kind="corrupt", probability=0.1}]}""".replace("\n", "")


@pytest.fixture(scope="module")
def messy() -> RunRecord:
    return simulate(
        resolve(
            load(
                SCENARIOS / "lane_following.toml",
                [
                    "plant.rate_hz=100", "controller.rate_hz=50", "horizon_s=6",
                    f"network.actuation={MESSY}", "controller.predictions=4",
                    'plant.watchdog.policy="model"', 'network.impairments=[{kind="delay", '
                    "delay_s=0.01, jitter_s=0.02}]", "trigger.beta=0.05",
                    "changes=[{at_s=2, set={'network.loss.probability'=0.3}}]",
                ],
            )
        )
    )  # fmt: skip


def test_each_direction_has_its_own_losses_and_guarantee(messy: RunRecord) -> None:
    updates, actuations = (packet_outcomes(messy, one) for one in messy.scenario.network.flows)
    assert actuations.longest_loss_burst() == 2
    assert updates.longest_loss_burst() in (3, 4)
    part = from_controller(messy, Flow.ACTUATION)
    assert part is not None
    assert part.sent == len(actuations.lost) == 300
    assert part.lost == actuations.lost.sum() > 90
    assert set(messy[NETEM_PACKET]["flow"].tolist()) == {0, 1}
    assert sum(unintended_losses(messy).values()) == 0


@pytest.mark.parametrize(("after_end_ms", "lost"), [(90, 1), (120, 0)])
def test_a_receiver_that_may_have_ended_loses_nothing(
    messy: RunRecord, after_end_ms: int, lost: int
) -> None:
    """An actuation that was delayed leaves the emulator after the end, and does not arrive."""
    received, packets = messy[PLANT_ACTUATION], messy[NETEM_PACKET].copy()
    outcomes = packet_outcomes(messy, Flow.ACTUATION)
    of_plant = np.isin(outcomes.sequence, received["sequence"])
    delayed = np.flatnonzero(of_plant & (outcomes.due_ns > outcomes.now_ns))[-1]
    place = np.flatnonzero(packets["flow"] == 1)[delayed]
    assert packets["bit"][place] == -1
    packets["release_ns"][place] = messy.scenario.timing.horizon_ns + after_end_ms * 10**6
    others = received[received["sequence"] != outcomes.sequence[delayed]]
    late = changed(messy, {PLANT_ACTUATION: others, NETEM_PACKET: packets})
    assert sum(unintended_losses(late).values()) == lost
