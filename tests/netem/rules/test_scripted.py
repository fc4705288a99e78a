"""Compare scripted and periodic losses with sets of packet numbers."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.link_machine import Link
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.periodic_loss import PeriodicLoss
from noack.impairments.loss_models.scripted import ScriptedLoss
from noack.impairments.loss_models.worst_case import WorstCaseLoss


def flags(loss: Loss, packets: Any) -> list[bool]:
    """Return which packets are lost; another script comes first, so the table offset is not 0."""
    other = LossOf(loss=ScriptedLoss(lost=(2**39, 2**39 + 1)))
    link = Link(LinkSettings(impairments=(other, LossOf(loss=loss))), 0, "a")
    link.decide(0, 1, 0)
    flow = link.flow(0)
    assert flow is not None
    found = []
    for flow.packets in packets:
        found.append(link.decide(0, 1, 0).fate == 1)
    return found


@given(st.sets(st.integers(0, 60)), st.integers(0, 40))
def test_exactly_the_named_ones_are_lost(names: set[int], extra: int) -> None:
    """A script applied once, and a repeated script."""
    script = tuple(sorted(names))
    assert flags(ScriptedLoss(lost=script), range(80)) == [k in names for k in range(80)]
    every = max(names, default=0) + 1 + extra
    again = flags(ScriptedLoss(lost=script, repeat_every=every), range(300))
    assert again == [k % every in names for k in range(300)]


@given(st.integers(1, 30), st.data(), st.integers(0, 50))
def test_of_every_period_a_burst_is_lost(period: int, data: st.DataObject, first: int) -> None:
    burst = data.draw(st.integers(0, period))
    expected = {first + k * period + j for k in range(200) for j in range(burst)}
    found = flags(PeriodicLoss(period=period, burst=burst, first=first), range(200))
    assert found == [k in expected for k in range(200)]


def test_large_packet_numbers_can_be_scripted() -> None:
    assert flags(ScriptedLoss(lost=(0, 2**40 - 1)), [0, 1, 2**40 - 2, 2**40 - 1, 2**40]) == [
        True, False, False, True, False,
    ]  # fmt: skip


def test_each_flow_has_its_own_packet_count(decide: Any) -> None:
    flows = np.array([0, 1, 1, 0, 1, 0, 0, 1])
    decided = decide([LossOf(loss=ScriptedLoss(lost=(0, 2)))], len(flows), flows=flows)
    assert (decided.fates == 1).tolist() == [
        packet in (0, 2) for packet in decided.verdicts["packet"]
    ]


def test_the_worst_case_without_a_cap_loses_every_packet(decide: Any) -> None:
    assert (decide([LossOf(loss=WorstCaseLoss())], 1000).fates == 1).all()
