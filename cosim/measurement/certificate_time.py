"""For which share of a trace's time a scenario's certificate would have been void, by cause.

Each packet of the trace is taken as an update that is sent at the packet's time. The conditions are
those of the scenario's certificates
(:func:`noack.theory.certificates.conditions.allowed_conditions`). Losses are counted as the claims
about a run count them: by the rules of the guarantee, and
:class:`cosim.analysis.claims.observed_conditions.PacketLosses`. A condition is violated

* by losses: from the sending of the packet whose loss is one too many, until a later packet is
  received;
* by a delay: from the end of the longest time that the certificate allows an update in the network,
  until it is received.

A packet that arrives out of order counts as lost if the newer one arrives after the allowed delay.
A bound of a run holds up to the first violation only, since it depends on all that happened before.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.observed_conditions import PacketLosses
from cosim.analysis.claims.run_certificates import scheduled_certificates
from netem.measurement.loss_bursts import Outcomes, outcomes
from netem.measurement.network_measurement import NetworkMeasurement
from netem.traces.packet_trace import PacketTrace
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import NetworkConditions, allowed_conditions, network_delay_ns

Times = NDArray[np.int64]
DELAY, ORDER, START = "delay", " (out of order)", "start"


@dataclass(frozen=True)
class VoidShare:
    """How long one condition was violated."""

    cause: str
    """``delay``, ``start``, or the name of a rule of the guarantee; with ``(out of order)`` if the rule would
    hold without the packets that arrive out of order."""
    share: float
    """Of the trace's time."""
    first_s: float
    """When it was first violated, since the first sending."""
    worst: float
    """The worst value: losses, or the longest delay in seconds."""
    text: str
    """In words, with the allowed value."""


@dataclass(frozen=True)
class CertificateTime:
    """The result for a scenario."""

    scenario: str
    certificates: dict[str, str | None]
    """By the plants that it covers: None, or why there is no certificate."""
    allowed_losses: int
    """The most consecutive losses that the guarantee of the scenario allows."""
    allowed_delay_s: float
    """In the network."""
    observed_s: float
    share: float
    """Share of the time in which any of the conditions was violated."""
    causes: tuple[VoidShare, ...]
    """Those that were violated."""
    kept: dict[str, str]
    """Those that were never violated, with the worst value in words."""

    @property
    def first_s(self) -> float | None:
        """When a condition was first violated, None if never: bounds hold up to then."""
        return min((cause.first_s for cause in self.causes), default=None)

    @property
    def answer(self) -> str:
        """Whether a certificate of the scenario covers the network as it was measured, and why not."""
        reasons = [*self.certificates.values()]
        if all(reasons):
            why = f"no, because there is no certificate: {reasons[0]}"
        elif self.causes:
            first = min(self.causes, key=lambda cause: cause.first_s)
            why = f"no, because {first.text} at worst; first violated at {first.first_s:.3f} s"
        else:
            why = "yes"
        return f"{self.scenario}: certified on this network: {why}"

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        return asdict(self) | {"first_s": self.first_s, "answer": self.answer}


def measured_certificate_time(measurement: NetworkMeasurement, scenario: Scenario) -> CertificateTime:
    """As :func:`certificate_time`; raise CallerError also if the delays are not known."""
    measurement.require_delays("a scenario's certificate (--for)")
    return certificate_time(measurement.trace, scenario)


def certificate_time(trace: PacketTrace, scenario: Scenario) -> CertificateTime:
    """Return for which share of the time the certificates of a scenario would have been void.

    Raises:
        CallerError: the scenario changes settings during the run, on which the conditions depend.
    """
    resolved = resolve(scenario)
    resolved.coverage.require_constant()
    # The certificates, and why there are none for some plants.
    certificates: dict[str, str | None] = {}
    if resolved.protocol.acknowledges:
        certificates["any plant"] = "a loop with acknowledgements cannot have one"
    for certificate in (each.certificate for each in scheduled_certificates(resolved)):
        certificates[certificate.scope] = certificate.void
    # The intervals in which each of their conditions was violated.
    limits = allowed_conditions(resolved)
    delay_ns = network_delay_ns(resolved, resolved.certificate.late_periods)
    end_ns = int(max(trace.sent_ns[-1], trace.received_ns.max()))
    conditions = list(_violations(trace, limits, delay_ns, end_ns))
    if resolved.network.initial_sync == "first_packet":
        conditions.append(_start(trace, delay_ns, end_ns))
    spans = [span for span in conditions if len(span.begin_ns)]
    total_ns = max(end_ns, 1)
    begins_ns = np.concatenate([[], *(span.begin_ns for span in spans)])
    ends_ns = np.concatenate([[], *(span.end_ns for span in spans)])
    return CertificateTime(
        scenario=resolved.name,
        certificates=certificates or {"any plant": "the scenario cannot have one"},
        allowed_losses=limits.dropouts,
        allowed_delay_s=delay_ns * 1e-9,
        observed_s=end_ns * 1e-9,
        share=_covered_ns(begins_ns, ends_ns) / total_ns,
        causes=tuple(
            VoidShare(
                span.cause,
                _covered_ns(span.begin_ns, span.end_ns) / total_ns,
                float(span.begin_ns.min()) * 1e-9,
                span.worst,
                span.text,
            )
            for span in spans
        ),
        kept={
            span.cause: f"kept: {span.text}" if span.worst else "kept"
            for span in conditions
            if not len(span.begin_ns) and not span.cause.endswith(ORDER)
        },
    )


@dataclass(frozen=True, eq=False)
class _Spans:
    """The k intervals in which a condition is violated; if there are none, its worst value."""

    cause: str
    begin_ns: Times
    """(k,)"""
    end_ns: Times
    """(k,) At most the end of the trace."""
    worst: float
    text: str


def _violations(
    trace: PacketTrace, limits: NetworkConditions, delay_ns: int, end_ns: int
) -> Iterator[_Spans]:
    """Yield the intervals of each cause: those of each rule of the guarantee, then the delay."""
    groups = outcomes(trace)
    yield from _loss_violations(trace, groups, limits, delay_ns, end_ns)
    in_order = ~groups.lost & ~groups.out_of_order
    delays_ns = trace.received_ns - trace.sent_ns
    late = in_order & (delays_ns > delay_ns)
    worst_s = float(delays_ns[in_order].max(initial=0)) * 1e-9
    yield _Spans(
        DELAY,
        trace.sent_ns[late] + delay_ns,
        trace.received_ns[late],
        worst_s,
        f"an update was in the network for {worst_s:.4g} s, {delay_ns * 1e-9:.4g} s allowed",
    )


def _loss_violations(
    trace: PacketTrace, groups: Outcomes, limits: NetworkConditions, delay_ns: int, end_ns: int
) -> Iterator[_Spans]:
    """Yield, for each rule, the intervals with too many drops, and those with too many losses."""
    sent_ns, sent_s = trace.sent_ns, np.asarray(trace.sent_ns * 1e-9)
    dropped_s = np.where(groups.lost, np.inf, 0.0)
    stale, replaced_s = groups.out_of_order, dropped_s.copy()
    replaced_s[stale] = (groups.newer_ns - sent_ns)[stale] * 1e-9
    # A violation by a lost packet lasts until a newer one is received; else, to the next packet.
    until_ns = np.where(replaced_s > 0, groups.newer_ns, np.append(sent_ns[1:], end_ns))
    until_ns = np.minimum(until_ns, end_ns)
    for rule in limits.guarantee.rules:
        losses, drops = (
            PacketLosses(sent_s, times_s).values(rule, delay_ns * 1e-9).value
            for times_s in (replaced_s, dropped_s)
        )
        by_drops = drops > rule.limit
        for suffix, is_violated in (("", by_drops), (ORDER, (losses > rule.limit) & ~by_drops)):
            values = losses if suffix else drops
            worst = float((losses[is_violated] if is_violated.any() else values).max(initial=0))
            yield _Spans(
                rule.name + suffix, sent_ns[is_violated], until_ns[is_violated], worst, rule.violation(worst)
            )


def _start(trace: PacketTrace, delay_ns: int, end_ns: int) -> _Spans:
    """Return the time without any update, if the first one is not the first to arrive.

    If it is, and late, the delay is what is violated.
    """
    groups, received_ns = outcomes(trace), trace.received_ns
    first_ns = int(received_ns[~groups.lost].min(initial=end_ns))
    if first_ns <= delay_ns or not (groups.lost | groups.out_of_order)[0]:
        return _Spans(START, np.zeros(0, np.int64), np.zeros(0, np.int64), 0.0, "")
    first_s, allowed_s = first_ns * 1e-9, delay_ns * 1e-9
    text = f"the first update was not received, none until {first_s:.4g} s, {allowed_s:.4g} s allowed"
    return _Spans(START, np.array([delay_ns]), np.array([first_ns]), first_s, text)


def _covered_ns(begin_ns: Times, end_ns: Times) -> int:
    """Return the length of the union of intervals."""
    order = np.argsort(begin_ns, kind="stable")
    begin_ns, end_ns = begin_ns[order], end_ns[order]
    latest_ns = np.append(-1, np.maximum.accumulate(end_ns))[:-1]
    return int(np.maximum(end_ns - np.maximum(begin_ns, latest_ns), 0).sum())
