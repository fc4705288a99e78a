"""A run's summary in words: a verdict of three lines, and remarks on its validity.

The terminal (:mod:`cosim.output.run_document`) and the report show them; :attr:`noack.Run.verdict`.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from cosim.analysis.conformance.verdicts import Failed
from cosim.analysis.summary.summary_model import (
    Claim,
    ClaimCause,
    ClaimKind,
    ClaimVerdict,
    ExitPart,
    IdealLoopPart,
    LoopSummary,
    OutputPart,
    RunSummary,
)
from cosim.output.claim_words import claim_reason
from cosim.output.run_tables import changes_in, shares_network, state_norm
from cosim.simulation.continuous import ContinuousSummary
from netem.core.errors import ExitStatus
from netem.core.number_format import at_most, counted, duration_at_least, number, percent
from netem.output.document import Sentence, SentenceRole
from netem.output.result_tables import Tone
from noack.protocol.wire_format import Rejection
from noack.runtime.counting_sockets import DROPPED_IN_FLOOD
from noack.runtime.end_reasons import HORIZON

_MOST_NAMED = 3
"""Largest number of claims of a verdict that are named."""
SETTLED_SHARE = 0.1
"""A loop is stable if ‖x‖ falls to this share of its largest value."""
_MOST_VIOLATIONS = 5
"""Violations that are listed."""
_MOST_GROWTH, _MOST_LATE = 10.0, 0.01
"""Least ratio of ‖x‖ at the end to that at the start, and least share of late steps, for a warning."""


_TIMES = {
    "delay_s": "updates that take effect after up to {}",
    "hold_s": "inputs up to {} old",
    "lead_s": "inputs computed up to {} ahead of the step that applies them",
    "start_s": "a first input after up to {}",
}
"""The times of a certificate, in words."""


_REJECTIONS: Mapping[str, str] = {
    Rejection.LENGTH: "wrong length",
    Rejection.VERSION: "another version",
    Rejection.RUN: "of another run",
    Rejection.FLOW: "of another flow",
    Rejection.LOOP: "of no loop of the run",
    Rejection.TAG: "not authentic",
    Rejection.SOURCE: "unknown source",
    Rejection.RANGE: "a number out of range",
    Rejection.STALE: "not newer than one before",
    Rejection.NOT_FINITE: "a number that is not finite",
    DROPPED_IN_FLOOD: "dropped in a flood",
}
"""Why a process rejected datagrams, in words."""


def _line(text: str, tone: Tone) -> Sentence:
    return Sentence(text=text, tone=tone, role=SentenceRole.VERDICT)


def verdict(summary: RunSummary) -> tuple[Sentence, ...]:
    """Return how the run ended and its state, whether its guarantee was kept, its transmissions."""
    loops = summary.loops
    events, deliveries = sum(loop.events for loop in loops), sum(loop.deliveries for loop in loops)
    ideal = None
    if isinstance(loops[0].ideal_loop, IdealLoopPart) and not shares_network(summary):
        ideal = loops[0].ideal_loop.events
    diverged = any(loop.diverged_at_s is not None for loop in loops)
    return (
        *(_outputs_line(loop, summary) for loop in loops[:1] if len(loops) == 1 and loop.outputs),
        ending_line(
            summary.exit,
            summary.reached_s,
            summary.horizon_s,
            "" if diverged and summary.exit.status == ExitStatus.FAILED else _states(loops),
            has_grown=any(map(_grew, loops)),
        ),
        _guarantee_line(loops),
        transmission_line(events, deliveries, ideal),
    )


def _outputs_line(loop: LoopSummary, summary: RunSummary) -> Sentence:
    """Return what became of the outputs, and what was guaranteed of them, in one sentence."""
    claims = [claim for claim in loop.claims if claim.until_s is None]  # they hold to the end of the run
    held = [claim for claim in claims if claim.output and claim.verdict == "held"]
    settles_s = {claim.output: claim.settles_s for claim in held if claim.settles_s is not None}
    bounded = {claim.output for claim in held}
    has_target = all(output.target is not None for output in loop.outputs)
    is_good = not _grew(loop) if has_target else loop.diverged_at_s is None
    texts, is_late = [], loop.certified_for is not None
    for output in loop.outputs:
        if output.allowed is None:
            continue
        allowed = f"{output.allowed:g} {output.unit}".rstrip()
        if output.settled_s is None:
            texts.append(f"{output.name} was not within {allowed} of its {output.target} at the end")
        else:
            since = f"from {output.settled_s:.3g} s on"
            texts.append(f"{output.name} was within {allowed} of its {output.target} {since}")
        promised = "" if output.target is None else _promise(settles_s.get(output.name))
        by = " by the end of the run" if output.name in bounded else ""  # later, or not at all
        lacking = "not guaranteed for delays as in this run" if is_late else f"not guaranteed{by}"
        texts[-1] += f" (guaranteed {promised})" if promised else f" ({lacking})"
        is_good = is_good and output.settled_s is not None
    together = " and "
    if not texts:
        together = ", and "
        texts = [
            f"{output.name} was at most {_with_unit(output.largest, output)}, "
            f"at the end {_with_unit(output.last, output)}"
            for output in loop.outputs
        ]
    packets = counted(loop.longest_loss_burst, "consecutive packet")
    losses = f", although up to {packets} {'was' if loop.longest_loss_burst == 1 else 'were'} lost"
    if not is_good or not has_target:
        losses = f", with up to {packets} lost"
    text = f"{together.join(texts)}{losses if loop.longest_loss_burst else ''}"
    if not has_target:
        text += "; their set-point is not known, as a class computes the input: controller.setpoint states it"
    return _line(text, Tone.GOOD if is_good else Tone.DOUBTFUL)


def _promise(settles_s: float | None) -> str:
    """Return from when on an output is within its allowed error; empty if this is not guaranteed."""
    if settles_s is None:
        return ""
    return f"from {at_most(settles_s, 3)} s on" if settles_s else "at all times"


def _grew(loop: LoopSummary) -> bool:
    """Return whether ‖x‖ diverged, or was much larger at the end than at the start."""
    return loop.diverged_at_s is not None or _is_larger(loop.initial_state_norm, loop.final_state_norm)


def _is_larger(first: float | None, final: float | None) -> bool:
    """Return whether a norm was much larger at the end than at the start."""
    return first is not None and final is not None and final > _MOST_GROWTH * first > 0


def _with_unit(value: float | None, output: OutputPart) -> str:
    return f"{number(value)} {output.unit}".rstrip()


def verdict_of_exact_run(summary: ContinuousSummary) -> list[Sentence]:
    """Return how a run in continuous time ended, and its transmissions."""
    state, failed = "", summary.exit_status == ExitStatus.FAILED
    if not failed:
        state = state_text(summary.initial_state_norm, summary.sup_state_norm, summary.final_state_norm, None)
    end = ExitPart(status=summary.exit_status, reason=summary.reason)
    has_grown = _is_larger(summary.initial_state_norm, summary.final_state_norm)
    return [
        ending_line(end, summary.reached_s, summary.horizon_s, state, has_grown=has_grown),
        transmission_line(summary.events, summary.deliveries),
    ]


def ending_line(
    end: ExitPart, reached_s: float, horizon_s: float, states: str = "", *, has_grown: bool = False
) -> Sentence:
    """Return how a run ended, with the words of :func:`state_text` about its loops.

    A run to the horizon is good unless a loop's ‖x‖ has grown.
    """
    length = f"{reached_s:g} s"
    length_of_horizon = f"{length} of {horizon_s:g} s"
    reason = "" if end.status == ExitStatus.OK and end.reason == HORIZON else end.reason
    says_when = reason.startswith("the plant failed at ")  # a simulation goes on to its horizon
    outcome, tone = {
        ExitStatus.OK: (f"completed {length}", Tone.DOUBTFUL if has_grown else Tone.GOOD),
        ExitStatus.FAILED: ("failed" if says_when else f"failed after {length_of_horizon}", Tone.BAD),
    }.get(ExitStatus(end.status), (f"stopped after {length_of_horizon}", Tone.DOUBTFUL))
    details = "; ".join(filter(None, (reason.removeprefix("stopped "), states)))
    return _line(f"{outcome}: {details}" if details else outcome, tone)


def state_of(largest: float | None, final: float | None, diverged_at_s: float | None) -> str:
    """Return the word for a loop's state: stable, bounded or diverged; empty without a state.

    It is stable if ‖x‖ is at the end at most a tenth of its largest value.
    """
    if diverged_at_s is not None:
        return "diverged"
    if largest is None or final is None:
        return ""
    return "stable" if final <= SETTLED_SHARE * largest else "bounded"


def state_text(
    first: float | None,
    largest: float | None,
    final: float | None,
    diverged_at_s: float | None,
    norm: str = "‖x‖",
) -> str:
    """Return a loop's state as that word, with the first or largest and the last ``norm``."""
    word = state_of(largest, final, diverged_at_s)
    if largest is None or final is None or diverged_at_s is not None:
        return word
    if largest == 0:
        return f"{word}, {norm} stayed at 0"
    if word == "stable":
        start, top = f"{first or 0.0:.3g}", f"{largest:.3g}"
        if first is not None and largest > first and top != start:
            return f"{word}, {norm} was {start} at the start, at most {top}, at the end {final:.3g}"
        return f"{word}, {norm} fell from {top} to {final:.3g}"
    if first is not None and _is_larger(first, final):
        return f"{norm} grew from {first:.3g} to {final:.3g}, it was at most {largest:.3g}"
    return f"{word}, {norm} was at most {largest:.3g}, at the end {final:.3g}"


def _states(loops: Sequence[LoopSummary]) -> str:
    states = [(loop.sup_state_norm, loop.final_state_norm, loop.diverged_at_s) for loop in loops]
    if len(states) == 1:
        return state_text(loops[0].initial_state_norm, *states[0], state_norm(loops[0]))
    counts = Counter(filter(None, (state_of(*state) for state in states)))
    (first, *rest) = counts.most_common() or [("", 0)]
    words = [f"{first[1]} of {len(loops)} loops {first[0]}"] if first[1] else []
    return ", ".join([*words, *(f"{count} {word}" for word, count in rest)])


def transmission_line(events: int, deliveries: int, ideal: int | None = None) -> Sentence:
    """Return the numbers of transmissions and deliveries, and that of the ideal loop."""
    beside = "" if ideal is None else f" ({ideal} in the ideal loop)"
    sent = "1 transmission" if events == 1 else f"{events} transmissions"
    return _line(f"{sent}{beside}, {deliveries} delivered", Tone.NEUTRAL)


class GuaranteeVerdict(NamedTuple):
    """Whether the claims about a loop held."""

    tone: Tone
    """Good: kept; doubtful: not checkable; bad: broken."""
    since_s: float = 0.0
    """From when on it is not."""
    why: str = ""
    """Why it is not; if it is kept, what limits it."""
    lacks_certificate: bool = False
    """Whether there is no certificate."""
    is_of_conformance: bool = False
    """Whether the run conforms up to this time only."""


def guarantee_of(loop: LoopSummary) -> GuaranteeVerdict:
    """Return whether the claims about a loop held, and the guarantee of consecutive losses.

    A claim that assumes an ideal loop cannot be broken by a run. Where a certificate covers the
    lateness of the run, lateness breaks nothing.
    """
    return _if_broken(loop) or _if_kept(loop) or _if_not_checkable(loop)


def _if_broken(loop: LoopSummary) -> GuaranteeVerdict | None:
    """Return since when and why the guarantee is broken; None if it is not."""
    broken = [(part.t_s, part.what) for part in loop.violations]
    # Of the guarantee the processes reported more, where they saw it broken.
    violated = [
        claim
        for claim in loop.claims
        if claim.verdict is ClaimVerdict.VIOLATED
        and not (claim.kind is ClaimKind.GUARANTEE and loop.violations)
    ]
    if violated:
        named = list(dict.fromkeys(claim.what for claim in violated))
        more = [f"{len(named) - _MOST_NAMED} more"] if len(named) > _MOST_NAMED else []
        since_s = min(claim.since_s or 0.0 for claim in violated)
        broken.append((since_s, "violated: " + "; ".join([*named[:_MOST_NAMED], *more])))
    return GuaranteeVerdict(Tone.BAD, *min(broken)) if broken else None


def _if_kept(loop: LoopSummary) -> GuaranteeVerdict | None:
    """Return what limits the guarantee that was kept.

    None if no certificate claims anything, or if some claims ended or were not checked and no claim of a
    certificate held. One certificate that held is enough: what ended besides is a limit.
    """
    certified = [claim for claim in loop.claims if claim.is_certified]
    if not certified:
        return None
    parts = (_certified_times(loop), _end_of_certificates(loop), _sample_of(loop))
    coverage = "; ".join(filter(None, parts))
    if not (ended := _ended_claims(loop)):
        return GuaranteeVerdict(Tone.GOOD, 0.0, coverage)
    if not any(claim.verdict is ClaimVerdict.HELD for claim in certified):
        return None
    many = f"{len(ended)} {'claim' if len(ended) == 1 else 'claims'} not checked to the end"
    return GuaranteeVerdict(
        Tone.GOOD, 0.0, "; ".join(filter(None, (coverage, f"{many}: {_reason(loop).why}")))
    )


def _if_not_checkable(loop: LoopSummary) -> GuaranteeVerdict:
    """Return from when on and why the guarantee cannot be checked."""
    if any(claim.is_certified for claim in loop.claims):
        return _reason(loop)
    why = next((claim_reason(claim, loop.conformance) for claim in _ended_claims(loop)), "")
    return GuaranteeVerdict(Tone.DOUBTFUL, 0.0, why or "no certificate covers this loop")


def is_covered(loop: LoopSummary) -> bool:
    """Whether one of the certificates covers the whole run: each of its claims held to the end."""
    claims: dict[str, list[Claim]] = {}
    for claim in loop.claims:
        if claim.is_certified:
            claims.setdefault(claim.source, []).append(claim)
    return any(
        all(claim.verdict == "held" and claim.until_s is None for claim in of_certificate)
        for of_certificate in claims.values()
    )


def _ended_claims(loop: LoopSummary) -> list[Claim]:
    """Return the claims that ended before the end of the run, or of which nothing was compared."""
    return [claim for claim in loop.claims if claim.verdict in (ClaimVerdict.ENDED, ClaimVerdict.UNCHECKED)]


def _ended_if_none_held(loop: LoopSummary) -> list[Claim]:
    """Return such claims of certificates, if no claim of a certificate held."""
    certified = [claim for claim in loop.claims if claim.is_certified]
    if any(claim.verdict is ClaimVerdict.HELD for claim in certified):
        return []
    return [claim for claim in _ended_claims(loop) if claim.is_certified]


def _reason(loop: LoopSummary) -> GuaranteeVerdict:
    """Return from when on, and why, the first of the ended claims of a loop says nothing more."""
    uncovered = _ended_if_none_held(loop)
    # A certificate that covered the run for some time says more than one that does not exist.
    candidates = [claim for claim in uncovered if claim.has_bound] or uncovered or _ended_claims(loop)
    reasons = [(claim_reason(claim, loop.conformance), claim) for claim in candidates]
    # Of equal times, the certificate of the scenario's own plant gives the reason, as in noack certify.
    reason, claim = min(
        reasons, key=lambda pair: (pair[1].since_s or 0.0, pair[1].source == "box certificate", pair[0])
    )
    conforms = claim.cause is ClaimCause.CONFORMANCE
    return GuaranteeVerdict(Tone.DOUBTFUL, claim.since_s or 0.0, reason, claim.lacks_certificate, conforms)


def _is_incomplete(loop: LoopSummary) -> bool:
    """Whether rows are missing from the record, or may be: a process has written no report."""
    return bool(loop.missing_samples) or (loop.replay is not None and not loop.replay.complete)


_OF_LATENESS = (Failed.LIMIT, Failed.WHEN, Failed.INPUT)
"""What a run that is late fails by."""


def _late_sources(loop: LoopSummary) -> list[str]:
    """Return the certificates for whose documents the run was too late."""
    return [
        part.certificate
        for part in loop.conformance
        if part.failure is not None and part.failure.kind in _OF_LATENESS
    ]


def _certified_times(loop: LoopSummary) -> str:
    """Return the times for which a run that was later than allowed is certified; else empty."""
    if loop.allowed is None or loop.certified_for is None or not _covers_lateness(loop):
        return ""
    names = [name for name in _TIMES if getattr(loop.certified_for, name) > getattr(loop.allowed, name)]
    times = [_TIMES[name].format(duration_at_least(getattr(loop.certified_for, name))) for name in names]
    return f"certified for {', '.join(times)}, as late as this run was"


def _end_of_certificates(loop: LoopSummary) -> str:
    """Return up to when certificates claim something, if settings changed; else empty."""
    until_s = next((claim.until_s for claim in loop.claims if claim.is_certified and claim.until_s), None)
    if until_s is None:
        return ""
    return f"certificates end at the change of settings at {until_s:.3f} s, (I1) was checked to the end"


def _sample_of(loop: LoopSummary) -> str:
    """Return of which share of the steps the motion was compared, of a long run; else empty."""
    share = min((part.share for part in loop.conformance if part.document), default=1.0)
    return f"the motion was compared at {percent(share)} of the steps" if share < 1 else ""


def _covers_lateness(loop: LoopSummary) -> bool:
    """Whether certificates of its lateness cover the whole run."""
    return loop.certified_for is not None and not _late_sources(loop)


def _guarantee_line(loops: Sequence[LoopSummary]) -> Sentence:
    """Return whether the guarantee was kept in the loops, the worst first."""
    guarantees = [(guarantee_of(loop), loop) for loop in loops]
    held = sum(claim.verdict == "held" for loop in loops for claim in loop.claims)
    claims = f"{held} {'claim' if held == 1 else 'claims'} held, none violated"
    tones = {kept.tone for kept, _ in guarantees}
    worst = next((tone for tone in (Tone.BAD, Tone.DOUBTFUL) if tone in tones), Tone.GOOD)
    concerned = [(kept, loop) for kept, loop in guarantees if kept.tone == worst]
    kept, loop = min(concerned, key=lambda pair: pair[0].since_s if pair[0].why else math.inf)
    name, count = "" if len(loops) == 1 else f"{loop.name}: ", f"{len(concerned)} of {len(loops)}"
    why = f": {name}{kept.why}" if kept.why else ""
    since = f"{kept.since_s:.3f} s"
    if worst == Tone.GOOD:
        where = "" if len(loops) == 1 else f" in all {len(loops)} loops"
        more_loops = sum(bool(other.why) for other, _ in concerned) - 1
        more = f" (and {more_loops} more {'loop' if more_loops == 1 else 'loops'})" if more_loops > 0 else ""
        text = f"guarantee kept{where}: {claims}" + (f"; {name}{kept.why}{more}" if kept.why else "")
    elif worst == Tone.BAD:
        where = "" if len(loops) == 1 else f" in {count} loops,"
        text = f"guarantee broken{where} since {since}{why}"
    elif len(loops) > 1:
        text = f"guarantee not checkable in {count} loops{why}"
    elif kept.is_of_conformance and kept.since_s > 0:
        text = f"conforms until {since}{why}; the bounds hold until then"
    elif kept.since_s > 0:
        text = f"guarantee kept until {since}, then not checkable{why}"
    else:
        text = f"guarantee not checkable{why}"
    return _line(text, worst)


def remarks(summary: RunSummary) -> Iterator[Sentence]:
    """Yield the remarks on one loop, the severe ones first; none if all went well."""
    (loop,) = summary.loops
    reason = guarantee_of(loop).why
    violations = [violation for violation in loop.violations if violation.what not in reason]
    for violation in violations[:_MOST_VIOLATIONS]:
        yield _severe(f"{violation.process} reported at {violation.t_s:.3f} s: {violation.what}")
    if (more := len(violations) - _MOST_VIOLATIONS) > 0:
        yield _severe(f"{counted(more, 'more report')} of this kind")
    if loop.replay is not None and loop.replay.bit_exact is False:
        yield _severe("the replay of the run differs from its record")
    yield from map(_warning, _warnings(summary, loop))
    for interval, change in changes_in(loop.changes):
        yield Sentence(text=f"{interval}: {change}", role=SentenceRole.REMARK)


def _severe(text: str) -> Sentence:
    """Return a remark about a guarantee that was broken."""
    return Sentence(text=text, tone=Tone.BAD, role=SentenceRole.REMARK)


def _warning(text: str) -> Sentence:
    return Sentence(text=text, lead="warning:", tone=Tone.DOUBTFUL, role=SentenceRole.REMARK)


def _has_clocks(loop: LoopSummary) -> bool:
    """Whether bounds of clocks' errors are recorded, as of a run on several hosts."""
    return loop.conditions is not None and loop.conditions.clock_error_s is not None


def _warnings(summary: RunSummary, loop: LoopSummary) -> Iterator[str]:
    yield from loop.uneven_periods
    plant = loop.lateness_us.get("plant")
    if plant and plant.late_steps > _MOST_LATE * plant.steps:
        share = 100 * plant.late_steps / plant.steps
        yield f"the plant missed {share:.0f} % of its deadlines: reduce speed or plant.rate_hz"
    first, last = loop.initial_state_norm, loop.final_state_norm
    grew = first is not None and last is not None and last > _MOST_GROWTH * first > 0
    if grew and loop.diverged_at_s is None:  # else it is the reason why the run ended
        yield f"{state_norm(loop)} grew from {first:.3g} to {last:.3g} during the run"
    if loop.missing_samples:
        where = ", ".join(f"{n:,} of {t}" for t, n in loop.missing_by_table.items())
        count = loop.missing_samples
        yield f"{counted(count, 'sample')} {'is' if count == 1 else 'are'} missing from the record: {where}"
    if loop.unintended_losses:
        where = ", ".join(f"{n:,} on {leg}" for leg, n in loop.unintended_losses_by_leg.items())
        count = loop.unintended_losses
        lost = f"{counted(count, 'datagram')} {'was' if count == 1 else 'were'} lost elsewhere"
        if _has_clocks(loop):
            yield f"{lost} (kernel, or between the hosts; firewalls must pass the ports): {where}"
        else:
            yield f"{lost} (kernel, or a process that did not respond): {where}"
    for role, reasons in loop.rejected_datagrams.items():
        counts = ", ".join(f"{n:,} ({_REJECTIONS.get(reason, reason)})" for reason, n in reasons.items())
        yield f"{role} rejected datagrams: {counts}"
    if guarantee_of(loop).lacks_certificate:
        yield (
            "no bound of ‖x‖ is certified: noack certify shows what would have to change; "
            "noack margin shows whether a time-triggered loop is proven stable"
        )
    late = _late_sources(loop)
    ended_well = summary.exit.status != ExitStatus.FAILED and not _is_incomplete(loop)
    if late and ended_well and summary.kind == "live":
        culprit = "A host or the network between hosts" if _has_clocks(loop) else "This machine"
        covered = any(claim.is_certified and claim.verdict == "held" for claim in loop.claims)
        sources = " and the ".join(dict.fromkeys(late))
        certificate = f"the {sources}" if covered else "any certificate"
        yield (
            f"{culprit} was later than {certificate} of this loop allows, so some claims were not "
            "checked to the end: use a less busy machine, or a lower speed"
        )
    if _has_clocks(loop) and loop.replay is not None and not loop.replay.complete:
        yield (
            "the record is incomplete. A process that could not reach the recorder names the file "
            "with its rows; copy it, and add it: noack summary RUN --add FILE"
        )
