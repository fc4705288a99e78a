"""Drive links with any impairments, and record traces of the packets' fates."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from netem.fates import FateRecorder
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import EVENT
from noack.core.core_library import ffi
from noack.impairments.link_settings import LinkSettings
from tests.oracles.link import Datagram, Link

MAX_GAP_NS = 3_000_000


class Arrival(NamedTuple):
    """A received datagram."""

    gap_ns: int
    """Time since the previous arrival."""
    flow: int
    size_bytes: int


def _numbered(sent: list[Arrival]) -> list[Arrival]:
    """Number flows as a relay does, in the order of their first datagrams."""
    numbers: dict[int, int] = {}
    return [arrival._replace(flow=numbers.setdefault(arrival.flow, len(numbers))) for arrival in sent]


arrivals = st.lists(
    st.builds(Arrival, st.integers(0, MAX_GAP_NS), st.integers(0, 2), st.integers(0, 40)),
    max_size=40,
).map(_numbered)


def payload(flow: int, packet: int, size_bytes: int) -> bytes:
    return np.random.default_rng([flow, packet]).bytes(size_bytes)


@dataclass
class Run:
    """The decisions and departures of a link."""

    decisions: list[Any] = field(default_factory=list)
    arrivals: list[tuple[int, int, int]] = field(default_factory=list)
    """Time in ns, flow, size in bytes."""
    departures: list[tuple[int, int, bytes]] = field(default_factory=list)
    """Time in ns, flow, payload; in the order in which they left."""

    @property
    def events(self) -> NDArray[Any]:
        """The events of the arrivals, as a relay hands them to a tap."""
        events = np.zeros(len(self.decisions), EVENT)
        for event, decision, arrival in zip(events, self.decisions, self.arrivals, strict=True):
            now_ns, event["flow"], event["size_bytes"] = arrival
            event["t_ns"] = 10**18 + now_ns
            for name in ("packet", "consecutive_losses", "fate", "bit", "copy_bit", "hold_back_ns"):
                event[name] = getattr(decision, name)
            for name, t_ns in (("", decision.release_ns), ("copy_", decision.copy_ns)):
                event[f"{name}delay_ns"] = t_ns - now_ns if t_ns != -1 else -1
        return events


def drive(link: Link, sent: Sequence[Arrival]) -> Run:
    """Send datagrams through a link, and wait for all departures."""
    run, now_ns, counts = Run(), 0, dict.fromkeys(range(10), 0)

    def release(until_ns: float) -> None:
        while (due_ns := link.next_deadline_ns()) is not None and due_ns <= until_ns:
            leaves(due_ns, link.on_timer(due_ns))

    def leaves(t_ns: int, outputs: Sequence[object]) -> None:
        run.departures.extend(
            (t_ns, output.flow, output.data) for output in outputs if isinstance(output, Datagram)
        )

    for arrival in sent:
        now_ns += arrival.gap_ns
        release(now_ns)
        data = payload(arrival.flow, counts[arrival.flow], arrival.size_bytes)
        counts[arrival.flow] += 1
        leaves(now_ns, link.handle(Datagram(arrival.flow, data), now_ns))
        run.decisions.append(ffi.new("noack_decision *", link.decision[0]))
        run.arrivals.append((now_ns, arrival.flow, arrival.size_bytes))
    release(float("inf"))
    return run


def spec_of(link_settings: LinkSettings, name: str = "a") -> LinkSpec:
    here = ("127.0.0.1", 0)
    return LinkSpec(name, here, here, link_settings, LinkSettings(), seed=7)


def record(path: Path, link_settings: LinkSettings, sent: Sequence[Arrival]) -> Run:
    """Send datagrams through a link, and record their fates."""
    run = drive(Link(link_settings, 7, "a", "forward"), sent)
    with FateRecorder(path, [spec_of(link_settings)]) as recorder:
        events = run.events
        middle = len(events) // 2
        departures = np.zeros(3, EVENT)
        departures["departure"] = 1
        recorder.take(np.concatenate([events[:middle], departures]), np.zeros(0, np.uint8))
        recorder.take(events[middle:], np.zeros(0, np.uint8))
    assert (recorder.rows, recorder.missing_events) == (len(sent), 0)
    return run
