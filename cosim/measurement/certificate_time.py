"""For which share of a trace's time a scenario's certificate would have been void, by cause.

Each packet of the trace is taken as an update of the scenario, sent when it was sent. The
conditions are those of the scenario's certificates
(:func:`noack.theory.run_conditions.allowed_conditions`), and losses are counted as the claims about
a run count them (:class:`cosim.analysis.claims.observed_conditions.PacketLosses`). A condition is
violated

* by consecutive losses: from the sending of the packet that is one too many, until a later packet
  is received;
* by a delay: from the end of the longest time that the certificate allows an update in the network,
  until it is received.

A packet that a later one overtakes counts as lost if the later one arrives after the allowed delay.
A claim about a run is void from the first violation on, since its bounds depend on all that
happened before.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.observed_conditions import PacketLosses, causes_of
from cosim.analysis.claims.run_evidence import scheduled_certificates
from cosim.measurement.loss_bursts import Flags, outcomes
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.theory.run_conditions import allowed_conditions, network_delay_ns
from noack.traces.packet_trace import PacketTrace

Times = NDArray[np.int64]
LOSSES, ORDER, DELAY = "consecutive losses", "out of order", "delay"
_NEVER_NS = np.iinfo(np.int64).max


@dataclass(frozen=True)
class VoidShare:
    """How long one condition was violated."""

    cause: str
    share: float
    """Of the trace's time."""
    first_s: float
    """When it was first violated, since the first sending."""
    worst: float
    """Largest number of consecutive losses, or the longest delay in seconds."""
    allowed: float


@dataclass(frozen=True)
class CertificateTime:
    """The result for a scenario."""

    scenario: str
    certificates: dict[str, str | None]
    """By the plants that it covers: None, or why there is no certificate."""
    allowed_losses: int
    """M − 1 of the scenario."""
    allowed_delay_s: float
    """In the network."""
    observed_s: float
    share: float
    """Share of the time in which any of the conditions was violated."""
    causes: tuple[VoidShare, ...]
    """Those that were violated. ``out of order``: too many consecutive losses, of which without the
    overtaken packets there would not have been too many."""

    @property
    def first_s(self) -> float | None:
        """When a condition was first violated, None if never: a claim is void from then on."""
        return min((one.first_s for one in self.causes), default=None)

    def to_json(self) -> dict[str, Any]:
        """Return all fields for JSON."""
        return asdict(self) | {"first_s": self.first_s}


def certificate_time(trace: PacketTrace, scenario: Scenario) -> CertificateTime:
    """Return for which share of the time the certificates of a scenario would have been void."""
    resolved = resolve(scenario)
    found: dict[str, str | None] = {}
    if not causes_of(resolved):
        found["every plant"] = "a loop with acknowledgements has no certificate"
    for one in scheduled_certificates(resolved):
        found[one.scope] = one.void if one.constants is None else None
    allowed = allowed_conditions(resolved)
    delay_ns = network_delay_ns(resolved, resolved.certificate.late_periods)
    end_ns = int(max(trace.sent_ns[-1], trace.received_ns.max()))
    spans = dict(_violations(trace, allowed.dropouts, delay_ns))
    every = [span.clipped(end_ns) for span in spans.values()]
    union = _covered_ns(*(np.concatenate(ends) for ends in zip(*every, strict=True)))
    return CertificateTime(
        scenario=resolved.name,
        certificates=found or {"every plant": "the scenario cannot have a certificate"},
        allowed_losses=allowed.dropouts,
        allowed_delay_s=delay_ns * 1e-9,
        observed_s=end_ns * 1e-9,
        share=union / end_ns if end_ns else 0.0,
        causes=tuple(
            VoidShare(
                cause,
                _covered_ns(*span.clipped(end_ns)) / end_ns if end_ns else 0.0,
                float(span.begin_ns.min()) * 1e-9,
                span.worst,
                delay_ns * 1e-9 if cause == DELAY else float(allowed.dropouts),
            )
            for cause, span in spans.items()
            if len(span.begin_ns)
        ),
    )


@dataclass(frozen=True, eq=False)
class _Spans:
    """The intervals in which a condition is violated, (k,), and the worst value."""

    begin_ns: Times
    end_ns: Times
    worst: float

    def clipped(self, end_ns: int) -> tuple[Times, Times]:
        """Return the intervals within the trace."""
        return self.begin_ns, np.minimum(self.end_ns, end_ns)


def _violations(trace: PacketTrace, allowed: int, delay_ns: int) -> Iterator[tuple[str, _Spans]]:
    """Yield the intervals of each cause."""
    found, sent_ns = outcomes(trace), trace.sent_ns
    sent_s, replaced_s = np.asarray(sent_ns * 1e-9), np.where(found.lost, np.inf, 0.0)
    dropped = PacketLosses(sent_s, replaced_s).consecutive(delay_ns * 1e-9).value
    overtaken = found.out_of_order
    replaced_s[overtaken] = (found.newer_ns - sent_ns)[overtaken] * 1e-9
    missed = PacketLosses(sent_s, replaced_s).consecutive(delay_ns * 1e-9).value
    # The packets of a burst: it is too long even without those that were overtaken, or not.
    for cause, counts, which in (
        (LOSSES, missed, dropped > allowed),
        (ORDER, missed, (missed > allowed) & ~(dropped > allowed)),
    ):
        yield cause, _Spans(sent_ns[which], found.newer_ns[which], _largest(counts, which))
    delay = trace.received_ns - sent_ns
    beyond = ~found.lost & ~overtaken & (delay > delay_ns)
    worst_s = _largest(delay, beyond) * 1e-9
    yield DELAY, _Spans(sent_ns[beyond] + delay_ns, trace.received_ns[beyond], worst_s)


def _largest(values: NDArray[Any], which: Flags) -> float:
    return float(values[which].max(initial=0))


def _covered_ns(begin_ns: Times, end_ns: Times) -> int:
    """Return the length of the union of intervals."""
    order = np.argsort(begin_ns, kind="stable")
    begin_ns, end_ns = begin_ns[order], end_ns[order]
    before_ns = np.concatenate([[_LOWEST_NS], np.maximum.accumulate(end_ns)[:-1]])[: len(begin_ns)]
    return int(np.maximum(end_ns - np.maximum(begin_ns, before_ns), 0).sum())


_LOWEST_NS = -1
