"""The acknowledgement baseline in the whole loop in virtual time, and in replay."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.certificates import Certificates
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.replay import replay
from cosim.analysis.run_summary import summarise
from cosim.analysis.summary_model import ClaimVerdict
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
    NETEM_RELEASE,
    NO_SEQUENCE,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    UPDATES,
    Fate,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.assumptions import AssumptionStatus, assumptions
from tests.cosim.record.changed_records import flipped
from tests.oracles.link import Link

SCENARIOS = Path(__file__).parents[3] / "scenarios"
COARSE = ("plant.rate_hz=100", "controller.rate_hz=100", "horizon_s=6")
MESSY = (
    "network.loss.probability=0.3",
    'network.impairments=[{kind="delay", delay_s=0.01, jitter_s=0.02},'
    ' {kind="duplicate", probability=0.3}, {kind="corrupt", probability=0.2}]',
    'network.acknowledgements={timeout_s=0.05, loss={model="bernoulli", probability=0.3},'
    ' impairments=[{kind="delay", delay_s=0.01, jitter_s=0.02},'
    ' {kind="duplicate", probability=0.3}, {kind="corrupt", probability=0.2}]}',
    "trigger.beta=0.02",
)


def acknowledged(*overrides: str) -> Scenario:
    return resolve(load(SCENARIOS / "lane_acknowledged.toml", [*COARSE, *overrides]))


def plain(*overrides: str) -> Scenario:
    return resolve(load(SCENARIOS / "lane_following.toml", [*COARSE, *overrides]))


@cache
def run_of(*overrides: str) -> RunRecord:
    return simulate(acknowledged(*overrides))


@pytest.fixture(scope="module")
def messy() -> RunRecord:
    return run_of(*MESSY)


def events(record: RunRecord) -> Any:
    rows = record[SENSOR_MEASUREMENT]
    return rows[rows["event"] != NO_SEQUENCE]


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


def test_the_summary_counts_acknowledgements(messy: RunRecord) -> None:
    for record in (messy, run_of()):
        summary = summarise(record, 0, "horizon").to_json()
        found = summary["acknowledgements"]
        assert found["sent"] == summary["deliveries"] == len(record[CONTROLLER_DELIVERY])
        assert found["received"] == len(record[SENSOR_ACKNOWLEDGEMENT])
        assert found["lost"] > 0
        assert 0 <= found["sent"] - found["lost"] - found["received"] <= 2  # in flight at the end
        assert summary["unintended_losses"] == summary["missing_samples"] == 0
        assert summary["identity_residual_max"] is None
    assert summarise(messy, 0, "horizon").to_json()["rejected_datagrams"]["sensor"].keys() <= {
        "length", "version", "run", "flow", "loop", "tag", "stale",
    }  # fmt: skip
    assert summarise(simulate(plain()), 0, "horizon").acknowledgements is None


def test_a_run_is_replayed_bit_for_bit(messy: RunRecord) -> None:
    found = replay(messy)
    assert found.bit_exact
    assert found.gaps == []
    assert found.inputs == sum(len(messy[table]) for table in messy.tables)
    compared = {leg.leg: leg.compared for leg in found.messages}
    packets = messy[NETEM_PACKET]
    assert compared["sensor → netem"] == (packets["flow"] == UPDATES).sum() > 10
    assert compared["controller → netem"] == (packets["flow"] == ACKNOWLEDGEMENTS).sum() > 10
    assert compared["netem → sensor"] == len(messy[SENSOR_ACKNOWLEDGEMENT]) > 5
    assert (messy[NETEM_RELEASE]["flow"] == ACKNOWLEDGEMENTS).any()


@pytest.mark.parametrize("bit", [0, 62])
def test_a_flipped_bit_of_an_acknowledgement_is_found(messy: RunRecord, bit: int) -> None:
    rows = messy[SENSOR_ACKNOWLEDGEMENT]
    for column in rows.dtype.names:
        if column == "now_ns" and bit < 62:
            continue  # nothing that the sensor does depends on it
        other = flipped(messy, SENSOR_ACKNOWLEDGEMENT, len(rows) // 2, column, bit)
        first = replay(other).first_difference
        assert first is not None
        if column not in ("input", "now_ns"):
            assert first.table in (SENSOR_ACKNOWLEDGEMENT, SENSOR_MEASUREMENT)


@pytest.mark.parametrize("flow", [UPDATES, ACKNOWLEDGEMENTS])
@pytest.mark.parametrize("column", ["head", "fate", "flow", "size_bytes", "sequence"])
def test_a_flipped_bit_of_a_packet_is_found_in_its_row(
    messy: RunRecord, flow: int, column: str
) -> None:
    row = int(np.flatnonzero(messy[NETEM_PACKET]["flow"] == flow)[5])
    # Two bits of the flow: one changes the direction, the other makes it invalid.
    for bit in (0, 5) if column == "flow" else (0,):
        first = replay(flipped(messy, NETEM_PACKET, row, column, bit)).first_difference
        assert first is not None
        assert first.table == NETEM_PACKET
        assert column == "flow" or first.row == row


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


def test_settings_of_the_reverse_direction_need_acknowledgements() -> None:
    with pytest.raises(
        CallerError, match=r"network\.acknowledgements.*there are none unless protocol"
    ):
        plain("network.acknowledgements.timeout_s=0.1")


def test_settings_of_the_reverse_direction_have_no_effect_with_protocol_none() -> None:
    back = ("network.protocol=none", "network.acknowledgements.timeout_s=0.1")
    assert not plain(*back).protocol.acknowledges
