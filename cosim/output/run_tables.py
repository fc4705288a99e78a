"""Tables of a run: key numbers, timing, claims."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cosim.analysis.run_summary import linearisation_rows
from cosim.analysis.summary_model import (
    ChangePart,
    Claim,
    DisturbancePart,
    EstimationPart,
    FidelityPart,
    FlowPart,
    LoopSummary,
    Quantiles,
    ReplayPart,
    RestartPart,
    RunSummary,
    WatchdogPart,
)
from cosim.output.assumptions_table import print_assumptions
from cosim.output.fidelity_table import summary_rows
from netem.words.words_to_settings import settings_of
from noack.core.number_format import NONE, duration, number, ratio, seconds, whole

Numbers = tuple[tuple[str, str], ...]
"""Quantities and their values, as text."""
Claims = Sequence[Claim]
TIMING_HEADINGS = ("p50", "p99", "p99.9", "max", "count", "missed")


def print_details(console: Console, summary: RunSummary) -> None:
    """Print everything that the summary of one loop has: numbers, timing, assumptions, claims."""
    (loop,) = summary.loops
    console.print(number_table(run_title(summary), key_numbers(summary)))
    if loop.lateness_us:  # none in virtual time
        console.print(_timing_table(loop))
        _print_realtime(console, loop.realtime)
    console.print("the paper's assumptions for this scenario:")
    print_assumptions(console, loop.assumptions)
    print_claims(console, loop.claims)


def run_title(summary: RunSummary) -> str:
    """Return the title of the tables of one loop: scenario, mode and cap."""
    (loop,) = summary.loops
    kind = "" if summary.kind == "live" else summary.kind
    return title_of(summary.scenario, loop.mode, summary.mansd, summary.constraints, kind)


def title_of(
    scenario: str, mode: str, mansd: int, constraints: Sequence[str] = (), kind: str = ""
) -> str:
    """Return the title of the tables of a run of one loop; ``kind`` is empty for a live run."""
    name = "model-based" if mode == "model" else "zero-order hold"
    further = "".join(f", {one}" for one in (*constraints, kind) if one)
    return f"{scenario}, {name}, M − 1 = {mansd}{further}"


def number_table(title: str, rows: Numbers) -> Table:
    """Return a run's numbers as a table."""
    table = Table(title=escape(title))
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def short_numbers(summary: RunSummary) -> Numbers:
    """Return the most important numbers of one loop, for 80 columns."""
    (loop,) = summary.loops
    compared = isinstance(loop.fidelity, FidelityPart)
    return (
        lost_row(loop.drops, loop.deliveries),
        *([_lost_of("actuations", loop.actuations)] if loop.actuations is not None else ()),
        longest_burst(summary.mansd, summary.constraints, loop.longest_loss_burst),
        _forced(loop),
        *_intervals(loop),
        *_norms(loop),
        *_lateness(loop),
        *_other_clocks(loop),
        *_replay_rows(loop.replay),
        *([next(summary_rows(loop.fidelity))] if compared else ()),
    )


def key_numbers(summary: RunSummary) -> Numbers:
    """Return all numbers of one loop."""
    (loop,) = summary.loops
    return (
        ("transmissions", str(loop.events)),
        ("deliveries", str(loop.deliveries)),
        *_losses(summary, loop),
        *_intervals(loop),
        *_norms(loop),
        *_record(loop),
        *_watchdog(loop.watchdog),
        *(linearisation_rows(found) if (found := loop.linearisation) else ()),
        *_estimation(loop.estimation),
        *_disturbances(loop.disturbances),
        *_replay_rows(loop.replay),
        *summary_rows(loop.fidelity),
    )


def _losses(summary: RunSummary, loop: LoopSummary) -> Iterator[tuple[str, str]]:
    yield _forced(loop)
    yield lost_row(loop.drops, loop.deliveries)
    if (rate := loop.loss_expected) is not None:
        yield "  expected loss rate with the cap", f"{100 * rate:.3g} %"
    causes = loop.drops_by_cause
    if set(causes) - {"dropped"}:
        for cause, count in causes.items():
            yield f"  of these {cause.replace('_', ' ')}", str(count)
    flows = {"acknowledgements": loop.acknowledgements, "actuations": loop.actuations}
    for name, sent in flows.items():
        if sent is not None:
            yield name, str(sent.sent)
            yield _lost_of(name, sent)
            yield f"longest loss burst of {name}", str(sent.longest_loss_burst)
    yield longest_burst(summary.mansd, summary.constraints, loop.longest_loss_burst)
    violated = [one.cause for one in loop.assumption_violations]
    yield "loss bursts beyond M − 1", str(violated.count("dropouts"))
    for constraint in summary.constraints:
        yield f"violations of {constraint}", str(violated.count(constraint))


def _lost_of(name: str, sent: FlowPart) -> tuple[str, str]:
    return f"{name} lost", f"{sent.lost} ({ratio(sent.lost, sent.sent)})"


def lost_row(lost: int, delivered: int) -> tuple[str, str]:
    """Return the row of the lost updates."""
    return "lost in the network", f"{lost} ({ratio(lost, lost + delivered)})"


def longest_burst(cap: int, constraints: Sequence[str], longest: int) -> tuple[str, str]:
    """Return the row of the longest loss burst, with the most consecutive losses allowed."""
    words = [f"mansd {cap}", *constraints]
    limit = settings_of(" ".join(words)).longest_burst
    if limit != cap:
        return f"longest loss burst (at most {limit} allowed)", str(longest)
    return f"longest loss burst (cap M − 1 = {cap})", str(longest)


def _forced(loop: LoopSummary) -> tuple[str, str]:
    return "deliveries forced by the guarantee", str(loop.forced_deliveries)


def _intervals(loop: LoopSummary) -> Numbers:
    return interval_rows(
        loop.inter_event_min_s, loop.inter_event_median_s, loop.inter_delivery_median_s
    )


def interval_rows(
    shortest_s: float | None, median_s: float | None, delivered_s: float | None
) -> Numbers:
    """Return the rows of the inter-event times, and of the median time between deliveries."""
    return (
        ("shortest inter-event time", seconds(shortest_s)),
        ("median inter-event time", seconds(median_s)),
        ("median time between deliveries", seconds(delivered_s)),
    )


def _norms(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    yield "‖x‖ at the start", number(loop.initial_state_norm)
    yield "‖x‖ at the end", number(loop.final_state_norm)
    errors = (loop.sup_e_s_norm, loop.sup_e_c_norm)
    yield "maximum ‖e_s‖, ‖e_c‖", ", ".join(map(number, errors))


def _record(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    yield "numerical check of x_c − x_s (I1)", number(loop.identity_residual_relative)
    if (until_s := loop.judged_until_s) is not None:
        yield "claims checked until", seconds(until_s)
    yield "missing samples", str(loop.missing_samples)
    yield "lost elsewhere (kernel)", str(loop.unintended_losses)
    yield from _clocks(loop)
    for one in loop.restarts:
        yield f"{one.process} was restarted", away(one)
    yield from changes_in(loop.changes)


def _clocks(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    """Yield the largest bound of a clock's error, if it is recorded."""
    error_s = None if loop.conditions is None else loop.conditions.clock_error_s
    if error_s is not None:
        yield "largest bound of a clock's error", duration(error_s)


def _other_clocks(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    """Yield the same of a run on hosts with different clocks."""
    if loop.conditions is not None and loop.conditions.clock_error_s:
        yield from _clocks(loop)


def _lateness(loop: LoopSummary) -> Iterator[tuple[str, str]]:
    """Yield the latency of updates and the missed deadlines of a live run."""
    if latency := loop.latency_us:
        quantiles = " / ".join(whole(one) for one in (latency.p50, latency.p99))
        yield "sensor-to-controller latency p50 / p99", f"{quantiles} µs"
    if late := loop.lateness_us:
        worst = max(late, key=lambda role: late[role].late_steps)
        missed, steps = late[worst].late_steps, late[worst].steps
        if missed:
            yield "most deadlines missed", f"{worst}, {missed} of {steps}"
        else:
            yield "deadlines missed", "none"


def changes_in(changes: Sequence[ChangePart]) -> Iterator[tuple[str, str]]:
    """Yield changes of settings during the run, each with its time."""
    for one in changes:
        yield f"changed at {one.t_s:.3f} s", one.what


def interval_of(claim: Claim) -> str:
    """Return the interval of a claim; empty for the whole run."""
    from_s, until_s = claim.from_s, claim.until_s
    if from_s == 0 and until_s is None:
        return ""
    return f"from {from_s:.3f} s " + ("on" if until_s is None else f"to {until_s:.3f} s")


def away(restart: RestartPart) -> str:
    """Return the interval in which a process was down, and the reason."""
    since, until = seconds(restart.last_s), seconds(restart.first_s)
    why = (restart.what or "").partition(": ")[2]
    when = f"at {until}" if restart.last_s is None else f"down from {since} to {until}"
    return f"{when}: {why}" if why else when


def _watchdog(found: WatchdogPart) -> Iterator[tuple[str, str]]:
    if trips := found.trips:
        times = "once" if trips == 1 else f"{trips} times"
        first, total = seconds(found.first_s), seconds(found.total_s)
        yield "watchdog: newest actuation too old", f"{times}, first at {first}, {total} in total"
        yield "  policy applied", found.policy


def _estimation(found: EstimationPart | None) -> Iterator[tuple[str, str]]:
    if found is not None:
        what = f"estimated ({found.observer})" if found.observer else "measured with noise"
        errors = (found.max, found.sup_e_c_norm)
        yield (
            f"state {what}: RMS ‖x̂ − x‖ in the second half", number(found.rms_second_half)
        )  # fmt: skip
        yield "  predicted for an exact model", number(found.expected_rms)
        yield "maximum ‖x̂ − x‖, ‖x_c − x‖", ", ".join(map(number, errors))


def _disturbances(found: Sequence[DisturbancePart]) -> Iterator[tuple[str, str]]:
    for one in found:
        sizes = f"{number(one.rms)}, {number(one.max)}"
        yield f"disturbance at the {one.at}: RMS, maximum", sizes


def print_claims(console: Console, claims: Claims) -> None:
    """Print the claims about a loop and their verdicts."""
    if not claims:
        return
    table = Table(title="claims checked against this run")
    for heading in claim_headings(claims):
        table.add_column(heading, justify="right" if heading == "share used" else "left")
    for (*cells, verdict), colour in claim_rows(claims):
        table.add_row(*map(escape, cells), Text(verdict, colour))
    console.print(table)
    if any(claim.ratio is not None for claim in claims):
        console.print(
            "[dim]share used: largest share of the bound reached during the run; 100 % is normal "
            "for a bound that is computed from the run itself. Sources: (I1) and certificates, "
            "docs/theory.md; eq:... and theorems, the paper[/]"
        )
    sources: dict[tuple[str, str], list[str]] = {}
    for claim in claims:
        if claim.verdict != "held" and claim.why:
            sources.setdefault((claim.verdict, claim.why), []).append(claim.source)
    for (verdict, why), of in sources.items():
        text = f"{verdict}: {'; '.join(dict.fromkeys(of))}: {why}"
        console.print(text, highlight=False, markup=False)


class ClaimRow(NamedTuple):
    """A row of the table of claims."""

    cells: tuple[str, ...]
    colour: str
    """Of the verdict."""


def claim_headings(claims: Claims) -> tuple[str, ...]:
    """Return the headings of the table of claims; the interval only if claims have one."""
    interval = ["interval"] if any(map(interval_of, claims)) else []
    return "source", "claim", *interval, "share used", "verdict"


def claim_rows(claims: Claims) -> Iterator[ClaimRow]:
    """Yield the rows of the table of claims."""
    has_interval = "interval" in claim_headings(claims)
    for claim in claims:
        since = "" if claim.since_s is None else f" since {claim.since_s:.3f} s"
        cells = (
            claim.source, claim.bound,
            *([interval_of(claim)] if has_interval else []),
            NONE if claim.ratio is None else f"{100 * claim.ratio:.3g} %",
            claim.verdict + since,
        )  # fmt: skip
        yield ClaimRow(cells, _CLAIM_COLOURS[claim.verdict])


_CLAIM_COLOURS = {
    "held": "green", "violated": "bold red", "void": "yellow", "not applicable": "dim",
}  # fmt: skip


def _replay_rows(verdict: ReplayPart | None) -> Iterator[tuple[str, str]]:
    if verdict is None:
        return
    word = "not possible"
    if verdict.bit_exact:
        word = f"bit-exact, {verdict.inputs:,} inputs"
    elif (first := verdict.first_difference) is not None:
        word = f"differs: {first.table}, row {first.row}, {first.column}"
    yield "replay", word if verdict.complete else f"{word} (record incomplete)"


def _timing_table(loop: LoopSummary) -> Table:
    table = Table(title="timing in µs of wall time (missed: deadlines missed)")
    for heading in ("", *TIMING_HEADINGS):
        table.add_column(heading, justify="right" if heading else "left")
    for row in timing_rows(loop):
        table.add_row(*row)
    return table


def timing_rows(loop: LoopSummary) -> Iterator[tuple[str, ...]]:
    """Yield the lateness of each process, and the latency; their columns: TIMING_HEADINGS."""
    for role, late in loop.lateness_us.items():
        counts = str(late.steps), str(late.late_steps)
        yield f"{role} lateness", *map(whole, _quantiles(late)), *counts
    if latency := loop.latency_us:
        quantiles = map(whole, _quantiles(latency))
        yield "sensor-to-controller latency", *quantiles, str(latency.updates), ""


def _quantiles(found: Quantiles) -> tuple[float | None, ...]:
    return found.p50, found.p99, found.p999, found.max


def _print_realtime(console: Console, realtime: dict[str, dict[str, str]]) -> None:
    """Print one line for all processes with the same real-time settings."""
    roles_by_settings: dict[str, list[str]] = {}
    for role in sorted(realtime):
        verdicts = realtime[role]
        text = ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items())
        if set(verdicts.values()) == {"applied"}:
            text = "all applied"
        roles_by_settings.setdefault(text, []).append(role)
    for text, roles in roles_by_settings.items():
        whose = "" if len(roles) == len(realtime) else f" of {', '.join(roles)}"
        console.print(f"real-time settings{whose}: {text}", highlight=False, markup=False)
