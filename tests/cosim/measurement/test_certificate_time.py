"""The time without a certificate, against a step through the trace."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import noack
from cosim.measurement.certificate_time import DELAY, certificate_time
from netem.core.errors import CallerError
from netem.traces.packet_trace import LOST_NS, PacketTrace, packet_trace
from noack.scenario.scenario import Scenario

MS = 1_000_000


def lane(**network: object) -> Scenario:
    return noack.load("lane_following", {f"network.{key}": value for key, value in network.items()})


LANE = lane(mansd=2)  # allows 4 ms in the network


def share(certificate_time: object, cause: str) -> float:
    return next((violation.share for violation in certificate_time.causes if violation.cause == cause), 0.0)  # type: ignore[attr-defined]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.one_of(st.none(), st.integers(0, 40)), min_size=2, max_size=14))
def test_shares_are_those_of_a_step_through_the_time(delays: list[int | None]) -> None:
    """In every millisecond: are more than two packets missing, is one, or the first, overdue?"""
    sent = 10 * np.arange(len(delays))
    received = [None if d is None else 10 * k + d for k, d in enumerate(delays)]
    lost = np.array([d is None for d in delays])
    trace = packet_trace(sent * MS, (sent + np.array([d or 0 for d in delays])) * MS, lost)
    end = max(sent[-1], *(t_ms for t_ms in received if t_ms is not None), 0)

    def replaced(k: int) -> float:
        return min((t_ms for t_ms in received[k + 1 :] if t_ms is not None), default=np.inf)

    stale = [t_ms is not None and replaced(k) < t_ms for k, t_ms in enumerate(received)]
    is_lost = [t_ms is None or (stale[k] and replaced(k) - 10 * k > 4) for k, t_ms in enumerate(received)]
    late = void = 0
    for ms in range(end):
        overdue = any(
            t_ms is not None and not stale[k] and 10 * k + 4 <= ms < t_ms for k, t_ms in enumerate(received)
        )
        missing = False
        for k in range(2, len(delays)):
            if all(is_lost[k - 2 : k + 1]) and 10 * k <= ms < replaced(k):
                missing = True
        has_none = received[0] is None or stale[0]  # the first is not the first to arrive
        none_yet = has_none and 4 <= ms < min((t_ms for t_ms in received if t_ms is not None), default=end)
        late += overdue
        void += overdue or missing or none_yet
    times = certificate_time(trace, LANE)
    assert times.allowed_delay_s == 0.004
    assert times.allowed_losses == 2
    if end:
        assert times.share == pytest.approx(void / end)
        assert share(times, DELAY) == pytest.approx(late / end)


def test_every_rule_of_the_guarantee_counts() -> None:
    """Two losses in any five packets, at 10 ms a packet: one too many from 60 to 71 ms."""
    scenario = lane(mansd=2, constraints=[{"kind": "at_most", "losses": 2, "window": 5}])
    sent, lost = 10 * np.arange(15), np.zeros(15, bool)
    lost[[2, 4, 6]] = True
    void = certificate_time(packet_trace(sent * MS, (sent + 1) * MS, lost), scenario)
    (cause,) = void.causes
    assert (cause.cause, cause.worst, cause.first_s) == ("atmost 2 in 5", 3, pytest.approx(0.06))
    assert void.kept["dropouts"] == "kept: 1 update lost, 2 allowed"
    assert cause.share == pytest.approx(11 / 141)


def test_the_first_update_must_be_received_unless_the_state_is_known() -> None:
    sent, lost = 10 * np.arange(15), np.zeros(15, bool)
    lost[:2] = True
    trace = packet_trace(sent * MS, (sent + 1) * MS, lost)
    (cause,) = certificate_time(trace, LANE).causes
    assert (cause.cause, cause.first_s, cause.worst) == ("start", pytest.approx(0.004), pytest.approx(0.021))
    assert cause.share == pytest.approx(17 / 141)
    assert certificate_time(trace, lane(mansd=2, initial_sync="known_state")).first_s is None


def test_conditions_that_change_during_the_run_are_not_compared_with_a_trace() -> None:
    """With M − 1 = 8 at the start and 2 from 1 s on, 4 losses at 3 s were 'kept: 8 allowed'."""
    sent_ns = np.arange(100) * 100_000_000
    received_ns = sent_ns + 1_000_000
    received_ns[30:34] = LOST_NS
    trace = PacketTrace(np.arange(100), sent_ns, received_ns)
    changes = [{"at_s": 1.0, "set": {"network.mansd": 2}}]
    scenario = noack.load("lane_following", {"network.mansd": 8, "changes": changes})
    with pytest.raises(CallerError, match="changes: needs settings that stay the same"):
        certificate_time(trace, scenario)
