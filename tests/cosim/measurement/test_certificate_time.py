"""The share of time in which a certificate is void, against a step through the time."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import noack
from cosim.measurement.certificate_time import DELAY, certificate_time
from noack.scenario.scenario import Scenario
from noack.traces.packet_trace import packet_trace
from noack.traces.trace_formats import read_trace

MS = 1_000_000
TRACES = Path(__file__).parents[3] / "noack/traces/shipped/cicv5g"


def lane(**network: object) -> Scenario:
    return noack.load("lane_following", {f"network.{key}": value for key, value in network.items()})


LANE = lane(mansd=2)  # allows 4 ms in the network


def share(found: object, cause: str) -> float:
    return next((one.share for one in found.causes if one.cause == cause), 0.0)  # type: ignore[attr-defined]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.one_of(st.none(), st.integers(0, 40)), min_size=2, max_size=14))
def test_shares_are_those_of_a_step_through_the_time(delays: list[int | None]) -> None:
    """In every millisecond: are more than two packets missing, is one overdue?"""
    sent = 10 * np.arange(len(delays))
    received = [None if d is None else 10 * k + d for k, d in enumerate(delays)]
    lost = np.array([d is None for d in delays])
    trace = packet_trace(sent * MS, (sent + np.array([d or 0 for d in delays])) * MS, lost)
    end = max(sent[-1], *(at for at in received if at is not None), 0)

    def replaced(k: int) -> float:
        return min((at for at in received[k + 1 :] if at is not None), default=np.inf)

    stale = [at is not None and replaced(k) < at for k, at in enumerate(received)]
    gone = [at is None or (stale[k] and replaced(k) - 10 * k > 4) for k, at in enumerate(received)]
    late = void = 0
    for ms in range(end):
        overdue = any(
            at is not None and not stale[k] and 10 * k + 4 <= ms < at
            for k, at in enumerate(received)
        )
        missing = False
        for k in range(2, len(delays)):
            if all(gone[k - 2 : k + 1]) and 10 * k <= ms < replaced(k):
                missing = True
        late += overdue
        void += overdue or missing
    found = certificate_time(trace, LANE)
    assert found.allowed_delay_s == 0.004
    assert found.allowed_losses == 2
    if end:
        assert found.share == pytest.approx(void / end)
        assert share(found, DELAY) == pytest.approx(late / end)


def test_every_rule_of_the_guarantee_counts() -> None:
    """Two losses in any five packets, at 10 ms a packet: one too many from 60 to 71 ms."""
    scenario = lane(mansd=2, constraints=[{"kind": "at_most", "losses": 2, "window": 5}])
    sent, lost = 10 * np.arange(15), np.zeros(15, bool)
    lost[[2, 4, 6]] = True
    found = certificate_time(packet_trace(sent * MS, (sent + 1) * MS, lost), scenario)
    (one,) = found.causes
    assert (one.cause, one.worst, one.first_s) == ("atmost 2 in 5", 3, pytest.approx(0.06))
    assert found.kept["dropouts"] == "kept: 1 consecutive updates lost, 2 allowed"
    assert one.share == pytest.approx(11 / 141)


def test_the_certificates_of_the_scenario_are_named() -> None:
    trace = read_trace(TRACES / "rural_n8_10kmh.csv")
    found = certificate_time(trace, lane())
    assert None in found.certificates.values()
    assert [one.cause for one in found.causes] == [DELAY]
    assert found.causes[0].worst == pytest.approx(9.744)
    slow = lane(impairments=[{"kind": "delay", "delay_s": 9.8}])
    kept = certificate_time(trace, slow)
    assert kept.share == 0.0
    assert kept.kept["dropouts"] == "kept"  # nothing was lost
    assert kept.kept[DELAY].startswith("kept: an update was in the network for 9.744 s, 9.8")
    acknowledged = certificate_time(trace, noack.load("lane_acknowledged"))
    assert all(reason is not None for reason in acknowledged.certificates.values())
