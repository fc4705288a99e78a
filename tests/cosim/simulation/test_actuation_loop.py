"""Actuations over the network: the loop in virtual time against the reference loop."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.loop_statistics import from_controller, unintended_losses
from cosim.analysis.replay import replay
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate, simulate_loops
from noack.core.errors import CallerError
from noack.impairments.loss_models.scripted import ScriptedLoss
from noack.protocol.record_tables import (
    ACTUATIONS,
    NETEM_PACKET,
    PLANT_ACTUATION,
    PLANT_STEP,
)
from noack.protocol.wire_format import Flow
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load, validate
from tests.cosim.record.changed_records import changed, flipped
from tests.oracles.comparison import Comparison

SCENARIOS = Path(__file__).parents[3] / "scenarios"
H_S, TICKS = 0.05, 7
A, B = np.array([[0.0, 1.0], [1.0, 0.3]]), np.array([[0.0], [1.0]])
K, TRUE_A = np.array([[-3.0, -2.0]]), np.array([[0.0, 1.1], [1.2, 0.2]])
LOST_UPDATES = (1,)
HOW: dict[str, tuple[str, int]] = {
    "hold": ("hold", 1), "zero": ("zero", 1), "model": ("model", 1), "2 then zero": ("zero", 2),
    "3 then hold": ("hold", 3), "4 then hold": ("hold", 4), "2 then model": ("model", 2),
}  # fmt: skip


def scenario(how: str, lost: Any = (), **more: Any) -> Scenario:
    policy, predictions = HOW[how]
    content: dict[str, Any] = {
        "name": "lossy", "horizon_s": TICKS * H_S,
        "model": {"A": A.tolist(), "B": B.tolist(), "gain": K.tolist()},
        "plant": {
            "draw": "given", "A": TRUE_A.tolist(), "B": B.tolist(), "initial_state": [1.0, -0.5],
            "rate_hz": 1 / H_S, "watchdog": {"policy": policy},
        },
        "controller": {"rate_hz": 1 / H_S, "predictions": predictions},
        "trigger": {"policy": "periodic", "period_s": 2 * H_S},
        "network": {
            "mansd": 3, "loss": {"model": "scripted", "lost": LOST_UPDATES},
            "actuation": {"loss": {"model": "scripted", "lost": lost}},
        },
    }  # fmt: skip
    return resolve(validate(content | more, "here"))


@pytest.mark.parametrize("how", HOW)
def test_every_pattern_of_lost_actuations_gives_the_inputs_of_the_reference(how: str) -> None:
    base = scenario(how)
    network = base.network
    assert network.actuation is not None
    for pattern in product((False, True), repeat=TICKS):
        lost = [k for k, is_lost in enumerate(pattern) if is_lost]
        loss = ScriptedLoss(lost=tuple(lost))
        actuation = network.actuation.model_copy(update={"loss": loss})
        changed = network.model_copy(update={"actuation": actuation})
        record = simulate(base.model_copy(update={"network": changed}))
        packets = record[NETEM_PACKET]
        actuations = packets[packets["flow"] == ACTUATIONS]
        assert actuations["sequence"][actuations["release_ns"] < 0].tolist() == lost
        Comparison(record)


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


def test_the_run_replays_bit_by_bit_and_a_flipped_bit_is_found(messy: RunRecord) -> None:
    result = replay(messy)
    assert result.bit_exact
    legs = {one.leg: one.compared for one in result.messages}
    assert legs["controller → netem"] == 300
    assert legs["netem → plant"] == len(messy[PLANT_ACTUATION])
    assert "controller → plant" not in legs
    for table, column in ((PLANT_ACTUATION, "predicted"), (PLANT_STEP, "entry")):
        assert not replay(flipped(messy, table, 40, column, 1)).bit_exact


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["network.protocol=ack", "network.actuation={mansd=1}"],
         'network.actuation = {"mansd": 1}: not with protocol = "ack"'),
        (["controller.predictions=33"],
         "controller.predictions = 33: an actuation carries 33 x 2 inputs; at most 64 numbers fit"),
        (["controller.predictions=31", 'plant.watchdog.policy="model"'],
         "31 x 2 inputs and 4 of x_c; at most 64 numbers fit"),
        (["controller.predictions=3", "plant.watchdog.timeout_s=0.005"],
         "shorter than a period of the controller times controller.predictions (0.006 s)"),
        (["network.actuation.loss={model=\"trace\", file=\"none.csv\"}"],
         "network.actuation.loss.file"),
    ],
)  # fmt: skip
def test_mistakes_are_named(changes: list[str], says: str) -> None:
    with pytest.raises(CallerError) as error:
        load(SCENARIOS / "lane_following.toml", changes)
    assert says in str(error.value)


def test_each_loop_has_actuations_and_a_guarantee_of_its_own(tmp_path: Path) -> None:
    path, fast = SCENARIOS / "lane_actuation_loss.toml", ["horizon_s=3", "plant.rate_hz=100"]
    single = simulate(resolve(load(path, fast)))
    for count in (1, 3):
        several = tmp_path / f"{count}.toml"
        several.write_text(f'{path.read_text()}\n[[loops]]\nname = "car"\ncount = {count}\n')
        loops = simulate_loops(load(several, fast)).loops
        bursts = [packet_outcomes(loop, Flow.ACTUATION).longest_loss_burst() for loop in loops]
        assert bursts == [3] * count
        parts = [from_controller(loop, Flow.ACTUATION) for loop in loops]
        assert [part and part.sent for part in parts] == [150] * count
        assert [sum(unintended_losses(loop).values()) for loop in loops] == [0] * count
        if count == 1:
            for table in (PLANT_STEP, PLANT_ACTUATION, NETEM_PACKET):
                names = [name for name in single[table].dtype.names if name != "head"]
                for name in names:
                    assert (single[table][name] == loops[0][table][name]).all(), (table, name)
