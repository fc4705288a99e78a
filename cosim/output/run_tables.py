"""Tables of a run, as rows of text: of its network and loops, and of one loop in detail.

The terminal (:mod:`cosim.output.run_document`), the report and the files of ``--tables`` show them.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from cosim.analysis.summary.plant_linearisation import linearisation_rows
from cosim.analysis.summary.summary_model import (
    ChangePart,
    Claim,
    ClaimVerdict,
    DeadlinesPart,
    IdealLoopPart,
    LoopSummary,
    NoIdealLoopPart,
    OutputPart,
    Quantiles,
    ReplayPart,
    RunSummary,
    WatchdogPart,
)
from cosim.output.claim_words import claim_reason
from netem.core.errors import ExitStatus
from netem.core.number_format import NONE, counted, duration, duration_at_least, number, ratio, seconds, whole
from netem.output.result_tables import KEY_VALUE, ResultTable, Tone
from netem.tc_words import settings_of
from noack.scenario.runtime_parameters import MANSD

Numbers = tuple[tuple[str, str], ...]
"""Quantities and their values, as text."""
Claims = Sequence[Claim]
_TIMING_HEADINGS = ("quantity", "p50", "p99", "p99.9", "max", "count", "missed")
_LOOP_HEADINGS = (
    "loop", "sent", "lost", "burst", "forced", "share, %", "delay, s", "‖e_c‖", "claims held",
)  # fmt: skip
LOOPS_CAPTION = (
    "burst: most consecutive losses; forced: delivered by the guarantee; share: of the "
    "forwarded bytes; delay and ‖e_c‖: largest"
)
_CLAIM_TONES = {
    "held": Tone.GOOD, "violated": Tone.BAD, "ended": Tone.DOUBTFUL, "unchecked": Tone.DOUBTFUL,
    "not applicable": Tone.QUIET,
}  # fmt: skip
_SCHEDULE = {
    "sampling_s": "between two measurements",
    "delay_s": "from an event to the plant",
    "hold_s": "age of an input",
    "lead_s": "lead of an input",
    "start_s": "until the first input",
}
_MOST_NETWORK_ROWS = 3
"""Rows about the network in a table of a run's loops."""
_SHORT = (
    "lost in the network", "actuations lost", "longest loss burst (", "deliveries forced",
    "median inter-event", "‖x‖", "sensor-to-controller",
    "deadlines missed", "largest bound of a clock", "replay",
)  # fmt: skip
"""How the most important numbers of a loop begin, which a terminal of 80 columns shows."""


def summary_tables(summary: RunSummary) -> Iterator[ResultTable]:
    """Yield the tables of a run: network and loops, or those of its only loop."""
    title = run_title(summary)
    if shares_network(summary):
        yield ResultTable("network", f"network of {title}", KEY_VALUE, network_rows(summary))
        yield loops_table(summary.loops, f"loops of {title}")
        return
    (loop,) = summary.loops
    yield ResultTable("numbers", title, KEY_VALUE, key_numbers(summary))
    if loop.claims:
        yield _claims_table(loop.claims, f"claims: {title}")
    yield from schedule_tables(loop)
    if loop.lateness_us:  # none in virtual time
        yield timing_table(loop)


def shares_network(summary: RunSummary) -> bool:
    """Whether several loops share the network; the page of one alone is that of the loop."""
    return len(summary.loops) > 1


def mode_words(mode: str) -> str:
    """Return what the controller does between updates."""
    return "model-based" if mode == "model" else "zero-order hold"


def state_norm(loop: LoopSummary) -> str:
    """Return the name of the norm that shows whether a loop came to rest."""
    return "‖x‖" if loop.setpoint is None else "‖x − x_r‖"


def run_facts(summary: RunSummary, directory: Path) -> list[tuple[str, str]]:
    """Return what a run was, how it ended, and its results, in a few lines."""
    loop, is_shared = summary.loops[0], shares_network(summary)
    mode = f"{len(summary.loops)} loops" if is_shared else mode_words(loop.mode)
    verdicts = Counter(str(claim.verdict) for loop in summary.loops for claim in loop.claims)
    norms = (loop.initial_state_norm, loop.final_state_norm)
    uneven = [line for each in summary.loops for line in each.uneven_periods]
    of_loop = [
        (
            "events",
            f"{loop.events}; {loop.deliveries} received, {loop.drops} lost, "
            f"longest loss burst {loop.longest_loss_burst}",
        ),
        (
            state_norm(loop),
            " → ".join("unknown" if norm is None else f"{norm:.3g}" for norm in norms),
        ),
    ]
    return [
        ("run", f"{summary.scenario}, {mode}, {summary.kind}, {caps_text(summary)}"),
        ("ended", f"at {summary.reached_s:g} s of {summary.horizon_s:g} s: {summary.exit.reason}"),
        *(network_rows(summary)[:_MOST_NETWORK_ROWS] if is_shared else of_loop),
        *(("periods", line) for line in dict.fromkeys(uneven)),
        ("claims", ", ".join(f"{n} {verdict}" for verdict, n in verdicts.items()) or "none"),
        ("directory", str(directory)),
    ]


# One loop


def run_title(summary: RunSummary) -> str:
    """Return the title of the tables of a run: scenario, mode of a single loop, and cap."""
    mode = "" if shares_network(summary) else summary.loops[0].mode
    kind = "" if summary.kind == "live" else summary.kind
    return title_of(summary.scenario, mode, caps_text(summary), summary.constraints, kind)


def title_of(scenario: str, mode: str, cap: str, constraints: Sequence[str] = (), kind: str = "") -> str:
    """Return the title of the tables of a run; ``kind`` is empty for a live run."""
    words = (scenario, mode and mode_words(mode), cap, *constraints, kind)
    return ", ".join(filter(None, words))


def short_numbers(summary: RunSummary) -> Numbers:
    """Return the most important numbers of one loop, for 80 columns."""
    (loop,) = summary.loops
    shown = ("|", *(start for start in _SHORT if not (loop.outputs and start == "‖x‖")))
    return tuple(row for row in key_numbers(summary) if row[0].startswith(shown))


def key_numbers(summary: RunSummary) -> Numbers:
    """Return all numbers of one loop."""
    (loop,) = summary.loops
    return (
        ("transmissions", str(loop.events)),
        ("deliveries", str(loop.deliveries)),
        *_losses(summary, loop),
        *interval_rows(loop.inter_event_min_s, loop.inter_event_median_s, loop.inter_delivery_median_s),
        *((f"|{_deviation(output)}| at most, at the end", _output_values(output)) for output in loop.outputs),
        (f"{state_norm(loop)} at the start", number(loop.initial_state_norm)),
        (f"{state_norm(loop)} at the end", number(loop.final_state_norm)),
        ("maximum ‖e_s‖, ‖e_c‖", f"{number(loop.sup_e_s_norm)}, {number(loop.sup_e_c_norm)}"),
        *_lateness(loop),
        *_record(loop),
        *_watchdog(loop.watchdog),
        *(linearisation_rows(loop.linearisation) if loop.linearisation else ()),
        *_estimation(loop),
        *_replay(loop.replay),
        *_ideal_loop(loop.ideal_loop),
    )


def _deviation(output: OutputPart) -> str:
    """Return the name of the distance of an output from what it follows."""
    return f"{output.name} − r" if output.target == "reference" else output.name


def _output_values(output: OutputPart) -> str:
    """Return the largest and the last distance of an output from its set-point."""
    return f"{number(output.largest)}, {number(output.last)} {output.unit}".rstrip()


def _losses(summary: RunSummary, loop: LoopSummary) -> Iterator[tuple[str, str]]:
    yield "deliveries forced by the guarantee", str(loop.forced_deliveries)
    yield lost_row(loop.drops, loop.deliveries)
    if (rate := loop.loss_expected) is not None:
        yield "  expected loss rate", f"{100 * rate:.3g} %"
    causes = loop.drops_by_cause
    if set(causes) - {"dropped"}:
        for cause, count in causes.items():
            yield f"  of these {cause.replace('_', ' ')}", str(count)
    flows = {"acknowledgements": loop.acknowledgements, "actuations": loop.actuations}
    for name, sent in flows.items():
        if sent is not None:
            yield name, str(sent.sent)
            yield f"{name} lost", f"{sent.lost} ({ratio(sent.lost, sent.sent)})"
            yield f"longest loss burst of {name}", str(sent.longest_loss_burst)
    yield burst_row(max(caps(summary)), summary.constraints, loop.longest_loss_burst)
    violated = [violation.cause for violation in loop.violations]
    yield "longer loss bursts than allowed", str(violated.count("dropouts"))
    for constraint in summary.constraints:
        yield f"violations of {constraint}", str(violated.count(constraint))


def lost_row(lost: int, delivered: int) -> tuple[str, str]:
    """Return the row of the lost updates."""
    return "lost in the network", f"{lost} ({ratio(lost, lost + delivered)})"


def caps(summary: RunSummary) -> list[int]:
    """Return the values of ``mansd`` of a run, which may have changed it, in their order."""
    changed = (change.settings.get(MANSD) for change in summary.changes)
    return [summary.mansd, *(cap for cap in changed if isinstance(cap, int))]


def caps_text(summary: RunSummary) -> str:
    """Write the values of ``mansd`` of a run, as in ``at most 3 → 1 lost in a row``."""
    return f"at most {' → '.join(map(str, caps(summary)))} lost in a row"


def burst_row(cap: int, constraints: Sequence[str], longest: int) -> tuple[str, str]:
    """Return the row of the longest loss burst, with the most consecutive losses allowed."""
    words = [f"mansd {cap}", *constraints]
    limit = settings_of(" ".join(words)).longest_burst
    return f"longest loss burst (at most {limit} allowed)", str(longest)


def interval_rows(shortest_s: float | None, median_s: float | None, delivered_s: float | None) -> Numbers:
    """Return the rows of the inter-event times, and of the median time between deliveries."""
    return (
        ("shortest inter-event time", seconds(shortest_s)),
        ("median inter-event time", seconds(median_s)),
        ("median time between deliveries", seconds(delivered_s)),
    )


def _record(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    yield "numerical check of x_c − x_s (I1)", number(loop.identity_residual_relative)
    if (until_s := loop.judged_until_s) is not None:
        yield "claims checked until", seconds(until_s)
    yield "missing samples", str(loop.missing_samples)
    yield "lost elsewhere (kernel)", str(loop.unintended_losses)
    if loop.conditions is not None and (error_s := loop.conditions.clock_error_s):
        yield "largest bound of a clock's error", duration(error_s)
    yield from changes_in(loop.changes)


def _lateness(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    """Yield the latency of updates and the missed deadlines of a live run."""
    if latency := loop.latency_us:
        quantiles = " / ".join(whole(value) for value in (latency.p50, latency.p99))
        yield "sensor-to-controller latency p50 / p99", f"{quantiles} µs"
    if lateness := loop.lateness_us:
        worst = max(lateness, key=lambda role: lateness[role].late_steps)
        late_steps, steps = lateness[worst].late_steps, lateness[worst].steps
        if late_steps:
            yield "deadlines missed, worst process", f"{worst}: {late_steps} of {steps} steps"
        else:
            yield "deadlines missed", "none"


def changes_in(changes: Sequence[ChangePart]) -> Iterator[tuple[str, str]]:
    """Yield changes of settings during the run, each with its time."""
    for change in changes:
        yield f"changed at {change.t_s:.3f} s", change.what


def interval_text(claim: Claim) -> str:
    """Return the interval of a claim; empty for the whole run."""
    return "" if claim.until_s is None else f"until the change at {claim.until_s:.3f} s"


def _watchdog(watchdog: WatchdogPart) -> Iterator[tuple[str, str]]:
    if trips := watchdog.trips:
        times = "once" if trips == 1 else f"{trips} times"
        first, total = seconds(watchdog.first_s), seconds(watchdog.total_s)
        yield "watchdog: newest actuation too old", f"{times}, first at {first}, {total} in total"
        yield "  policy applied", watchdog.policy


def _estimation(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    if (estimation := loop.estimation) is not None:
        source = f"estimated ({estimation.observer})" if estimation.observer else "measured with noise"
        rms = number(estimation.rms_second_half)
        yield f"state {source}: RMS ‖x̂ − x‖ in the second half", rms
        yield "  predicted for an exact model", number(estimation.expected_rms)
        yield "maximum ‖x̂ − x‖, ‖x_c − x‖", f"{number(estimation.max)}, {number(estimation.sup_e_c_norm)}"
    for disturbance in loop.disturbances:
        sizes = f"{number(disturbance.rms)}, {number(disturbance.max)}"
        yield f"disturbance at the {disturbance.at}: RMS, maximum", sizes


def _ideal_loop(ideal: IdealLoopPart | NoIdealLoopPart | None) -> Iterator[tuple[str, str]]:
    if isinstance(ideal, NoIdealLoopPart):
        yield "difference to the ideal loop", f"not compared: {ideal.reason}"
    elif ideal is not None:
        of_x = f" ({number(100 * ideal.rms_difference / ideal.rms_x, 3)} % of x)" if ideal.rms_x else ""
        yield "difference to the ideal loop, RMS", f"{ideal.rms_difference:.3g}{of_x}"
        yield "transmissions of the ideal loop", str(ideal.events)


def _claims_table(claims: Claims, title: str) -> ResultTable:
    """Return the table of claims; it has their intervals only if some are not the whole run."""
    intervals = [[interval_text(claim)] for claim in claims]
    has_interval = any(interval != [""] for interval in intervals)
    headings = ("source", "claim", *(["interval"] if has_interval else []), "share used", "verdict")
    rows = []
    for claim, interval in zip(claims, intervals, strict=True):
        share = NONE if claim.ratio is None else f"{100 * claim.ratio:.3g} %"
        rows.append(
            (claim.origin, claim.bound, *(interval if has_interval else ()), share, verdict_text(claim))
        )
    left = [i for i, heading in enumerate(headings) if heading != "share used"]
    return ResultTable("claims", title, headings, rows, left=left, tones=_CLAIM_TONES)


def verdict_text(claim: Claim) -> str:
    """Return the verdict of a claim, with its time."""
    if claim.since_s is None or claim.verdict is ClaimVerdict.UNCHECKED:
        return str(claim.verdict)
    word = "at" if claim.verdict is ClaimVerdict.ENDED else "since"
    return f"{claim.verdict} {word} {claim.since_s:.3f} s"


def claims_in_full(loop: LoopSummary) -> ResultTable:
    """Return the table of a loop's claims with their bounds in words and numbers, for a page."""
    rows = []
    for claim in loop.claims:
        what = ", ".join(filter(None, (claim.what, interval_text(claim))))
        share = NONE if claim.ratio is None else f"{number(100 * claim.ratio)} %"
        numbers = (
            claim.certified_text or NONE,
            number(claim.observed, 4),
            share,
        )
        rows.append(
            (
                what,
                claim.origin,
                claim.bound,
                *numbers,
                claim_reason(claim, loop.conformance),
                verdict_text(claim),
            )
        )
    headings = ("claim", "source", "bound", "certified", "observed", "share used", "why", "verdict")
    caption = "Bounds, compared with the run"
    return ResultTable("", caption, headings, rows, left=(0, 1, 2, 6, 7), tones=_CLAIM_TONES)


def _replay(verdict: ReplayPart | None) -> Iterator[tuple[str, str]]:
    if verdict is None:
        return
    word = "not possible"
    if verdict.bit_exact:
        word = f"bit-exact, {verdict.inputs:,} inputs"
    elif (first := verdict.first_difference) is not None:
        word = f"differs: {first.table}, row {first.row}, {first.column}"
    yield "replay", word if verdict.complete else f"{word} (record incomplete)"


def schedule_tables(loop: LoopSummary) -> Iterator[ResultTable]:
    """Yield the table of the times on which proofs depend, if the loop can have any."""
    if (allowed := loop.allowed) is None or (observed := loop.conditions) is None:
        return
    exists = any(claim.is_certified and claim.has_bound for claim in loop.claims)
    certified = (loop.certified_for or allowed) if exists else None
    rows = []
    for name, words in _SCHEDULE.items():
        times_s = [getattr(part, name) if part else None for part in (allowed, observed, certified)]
        if not any(times_s):  # no input was computed for a later time
            continue
        # At a set-point a certificate needs no first input: it is 0 there.
        texts = (duration, duration, duration_at_least)
        cells = [text(time_s) if time_s else NONE for text, time_s in zip(texts, times_s, strict=True)]
        if (times_s[1] or 0.0) > (times_s[0] or 0.0):
            cells[1] += " (late)"
        rows.append((words, *cells))
    caption = "largest times: allowed by the scenario, observed, covered by the certificates used"
    yield ResultTable("schedule", caption, ("", "allowed", "observed", "certified"), rows)


def timing_table(loop: LoopSummary) -> ResultTable:
    """Return the table of the lateness of each process, and of the latency."""
    rows = [
        (f"{role} lateness", *_quantiles(late), str(late.steps), str(late.late_steps))
        for role, late in loop.lateness_us.items()
    ]
    if latency := loop.latency_us:
        name = "sensor-to-controller latency"
        rows.append((name, *_quantiles(latency), str(latency.updates), ""))
    caption = "lateness of each process, and latency, in µs of wall time (missed: deadlines missed)"
    return ResultTable("timing", caption, _TIMING_HEADINGS, rows)


def _quantiles(quantiles: Quantiles) -> tuple[str, ...]:
    return tuple(map(whole, (quantiles.p50, quantiles.p99, quantiles.p999, quantiles.max)))


# The network and all loops


def badness(loop: LoopSummary) -> tuple[float, ...]:
    """Return a key that is larger for a worse loop."""
    claims, error = _verdicts(loop), loop.sup_e_c_norm
    return (
        loop.exit.status != ExitStatus.OK,
        claims["violated"],
        claims["ended"] + claims["unchecked"],
        loop.longest_loss_burst,
        float("inf") if error is None else error,
    )


def _verdicts(loop: LoopSummary) -> Counter[str]:
    return Counter(str(claim.verdict) for claim in loop.claims)


def network_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the quantities of the network, and their values as text."""
    network, in_flight = summary.network, summary.network.in_flight
    sent, reached_s = network.datagrams, summary.reached_s or math.inf
    lost = sum(network.drops_by_cause.values())
    by_cause = network.drops_by_cause.items() if set(network.drops_by_cause) - {"dropped"} else ()
    causes = "".join(f", {n} {cause.replace('_', ' ')}" for cause, n in by_cause)
    rows = [
        ("updates of all loops", f"{sent} ({sent / reached_s:.4g} /s)"),
        ("lost", f"{lost} ({ratio(lost, sent)}){causes}"),
        burst_row(max(caps(summary)), summary.constraints, network.longest_loss_burst),
        ("forced by the guarantee", str(network.forced_deliveries)),
        ("datagrams in flight: mean, max", f"{in_flight.mean:.3g}, {in_flight.max}"),
    ]
    if network.rate_bps is not None and network.utilisation is not None:
        usage = f"{100 * network.utilisation:.3g} % of {network.rate_bps:,} bit/s"
        rows.append(("link used", usage.replace(",", " ")))
    loops = summary.loops
    if flows := [loop.actuations for loop in loops if loop.actuations is not None]:
        sent, lost = (sum(getattr(flow, key) for flow in flows) for key in ("sent", "lost"))
        rows.append(("actuations of all loops", f"{sent} ({sent / reached_s:.4g} /s)"))
        burst = max(flow.longest_loss_burst for flow in flows)
        rows.append(("  lost, longest loss burst", f"{lost} ({ratio(lost, sent)}), {burst}"))
    if trips := [loop.watchdog.trips for loop in loops if loop.watchdog.trips]:
        rows.append(("watchdog acted", f"{counted(sum(trips), 'time')}, in {counted(len(trips), 'loop')}"))
    if deadlines := summary.deadlines:
        rows.append(("deadlines missed", _missed_deadlines(deadlines)))
        worst = max(deadlines, key=lambda role: deadlines[role].max_us or 0.0)
        latest_s = 1e-6 * (deadlines[worst].max_us or 0.0)
        rows.append(("  largest lateness", f"{duration(latest_s)} ({worst})"))
    if (replay := network.replay) is not None:
        exact = {True: "bit-exact", False: "differs", None: "not possible"}[replay.bit_exact]
        rows.append(("replay of the network", exact))
        count = sum(loop.replay is not None and loop.replay.bit_exact is True for loop in loops)
        rows.append(("replay of the loops", f"bit-exact: {count} of {len(loops)}"))
        missing, lost = (
            sum(getattr(loop, key) for loop in loops) for key in ("missing_samples", "unintended_losses")
        )
        rows.append(("missing samples, unintended losses", f"{missing}, {lost}"))
    return [*rows, *changes_in(summary.changes)]


def _missed_deadlines(deadlines: Mapping[str, DeadlinesPart]) -> str:
    late_roles = [(role, part.late_steps, part.steps) for role, part in deadlines.items() if part.late_steps]
    texts = [f"{role} {late_steps} of {steps}" for role, late_steps, steps in late_roles]
    return ", ".join(texts) or "none"


def loops_table(loops: Sequence[LoopSummary], title: str) -> ResultTable:
    """Return the table of the loops; :data:`LOOPS_CAPTION` explains its columns."""
    return ResultTable("loops", title, _LOOP_HEADINGS, [*map(loop_row, loops)])


def loop_row(loop: LoopSummary) -> tuple[str, ...]:
    """Return the row of a loop in the table of all loops."""
    claims = _verdicts(loop)
    held_text = f"{claims['held']} of {sum(claims.values())}"
    worse = [f"{claims['violated']} violated"] if claims["violated"] else []
    if loop.exit.status == ExitStatus.FAILED:
        worse = ["failed"]
    return (
        loop.name,
        str(loop.events),
        str(loop.drops),
        str(loop.longest_loss_burst),
        str(loop.forced_deliveries),
        number(100 * (loop.link_share or 0.0)),
        number(loop.delay_max_s),
        number(loop.sup_e_c_norm),
        ", ".join([held_text, *worse]),
    )
