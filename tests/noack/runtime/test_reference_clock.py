"""A process with another clock follows the coordinator's; the true difference is in the bound."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from benchmarks.hosts import DrivenClocks
from noack.core.clock import NS_PER_S
from noack.core.errors import PeerError
from noack.runtime.host_clocks.reference_clock import (
    LOST_AFTER_NS,
    ClockReport,
    ReferenceClock,
    reference_clock,
)
from noack.runtime.host_clocks.time_exchange import HostClocks, TimeReference, answering
from noack.runtime.join_ticket import new_ticket
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import validate

KEY = bytes(range(32))
ROOMY = ClocksSection(largest_error_us=1e6)  # a busy machine gives wide bounds


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as entered:
        yield entered


def reference_at(stack: ExitStack, port: int = 0) -> TimeReference:
    found = stack.enter_context(closing(TimeReference(("127.0.0.1", port), KEY)))
    return stack.enter_context(answering(found))


def following(
    stack: ExitStack, clocks: HostClocks, settings: ClocksSection = ROOMY
) -> ReferenceClock:
    clock = ReferenceClock(reference_at(stack).address, KEY, settings, clocks)
    stack.enter_context(closing(clock))
    clock.wait_until_known()
    return clock


def polled(clock: ReferenceClock, readings: int = 20) -> ClockReport:
    """Read the clock, then poll; fail if a reading was outside of the bound, or backward."""
    found, newest_ns = [], clock.monotonic_ns()
    for _ in range(readings):
        before_ns = time.monotonic_ns()
        own_ns = clock.monotonic_ns()
        found.append((before_ns, own_ns, time.monotonic_ns()))
        assert own_ns >= newest_ns
        newest_ns = own_ns
        time.sleep(0.001)
    report = clock.poll()
    assert clock.monotonic_ns() >= newest_ns
    if report.error_ns is not None:
        for before_ns, own_ns, after_ns in found:
            assert before_ns - report.error_ns <= own_ns <= after_ns + report.error_ns
    return report


@pytest.mark.parametrize(
    ("offset_ns", "drift_ppb"),
    [(NS_PER_S, 100_000), (-NS_PER_S, -100_000), (-NS_PER_S, 1_000_000)],
)
def test_the_difference_to_the_coordinators_clock_is_in_the_bound(
    stack: ExitStack, offset_ns: int, drift_ppb: int
) -> None:
    clocks = DrivenClocks(offset_ns, drift_ppb)
    clock, since_ns = following(stack, clocks), None
    for _ in range(15):
        report = polled(clock)
        assert report.lost is None or report.now_ns - report.since_ns > LOST_AFTER_NS
        assert since_ns in (None, report.since_ns)
        since_ns = report.now_ns


def test_a_bound_without_answers_is_lost_and_found_again(stack: ExitStack) -> None:
    with ExitStack() as first:
        port = reference_at(first).address[1]
        clock = ReferenceClock(("127.0.0.1", port), KEY, ROOMY, DrivenClocks())
        stack.enter_context(closing(clock))
        clock.wait_until_known()
        assert polled(clock).lost is None
    polled(clock)  # reads the replies that wait
    time.sleep(LOST_AFTER_NS / NS_PER_S)
    report = polled(clock)
    assert report.error_ns is None
    assert report.lost == f"no answer from 127.0.0.1:{port} for 0.5 s"
    reference_at(stack, port)  # after a reboot: another clock
    causes = [polled(clock).lost]
    while causes[-1] is not None:
        causes.append(polled(clock).lost)
    assert "the reference has another clock than before" in causes


def test_it_does_not_begin_without_an_answer_or_with_a_wide_bound(stack: ExitStack) -> None:
    silent = stack.enter_context(closing(TimeReference(("127.0.0.1", 0), KEY)))
    clock = stack.enter_context(closing(ReferenceClock(silent.address, KEY, ROOMY)))
    with pytest.raises(PeerError, match=r"clock with the coordinator's: no answer from 127\.0"):
        clock.wait_until_known(wait_s=0.05)
    with pytest.raises(PeerError):
        clock.wait_until_known(lambda: True)
    narrow = ClocksSection(largest_error_us=1e-3)
    address = reference_at(stack).address
    clock = stack.enter_context(closing(ReferenceClock(address, KEY, narrow)))
    with pytest.raises(PeerError, match=r"known within \d+ µs, 0\.001 µs allowed$"):
        clock.wait_until_known(wait_s=0.2)


def test_a_process_with_another_clock_needs_a_reference(content: dict[str, Any]) -> None:
    scenario = validate(content | {"loops": [{"name": "one", "count": 2}]}, "small")
    ticket = new_ticket(scenario, Path("run"), launched=False)
    assert reference_clock(ticket) is None
    with pytest.raises(PeerError, match="answers no requests for the time"):
        reference_clock(ticket.model_copy(update={"clock": "another"}))
