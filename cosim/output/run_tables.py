"""Tables of a run: key numbers, timing, claims."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cosim.analysis.model_comparison import linearisation_rows
from cosim.analysis.run_summary import Summary
from cosim.output.assumptions_table import print_assumptions
from cosim.output.fidelity_table import summary_rows
from netem.words.words_to_settings import settings_of
from noack.core.number_format import NONE, duration, number, ratio, seconds, whole

Numbers = tuple[tuple[str, str], ...]
"""Quantities and their values, as text."""
Claims = Sequence[dict[str, Any]]
_QUANTILES = ("p50", "p99", "p999", "max")
TIMING_HEADINGS = ("p50", "p99", "p99.9", "max", "count", "missed")


def print_details(console: Console, summary: Summary) -> None:
    """Print everything that a summary has: numbers, timing, assumptions, claims."""
    console.print(number_table(summary, key_numbers(summary)))
    if summary["lateness_us"]:  # none in virtual time
        console.print(_timing_table(summary))
        _print_realtime(console, summary["realtime"])
    console.print("the paper's assumptions for this scenario:")
    print_assumptions(console, summary["assumptions"])
    print_claims(console, summary)


def run_title(summary: Summary) -> str:
    """Return the title of a run's tables: scenario, mode and cap."""
    mode = "model-based" if summary["mode"] == "model" else "zero-order hold"
    kind = "" if summary["kind"] == "live" else f", {summary['kind']}"
    further = "".join(f", {constraint}" for constraint in summary.get("constraints", ()))
    return f"{summary['scenario']}, {mode}, M − 1 = {summary['mansd']}{further}{kind}"


def number_table(summary: Summary, rows: Numbers) -> Table:
    """Return a run's numbers as a table; its title names scenario, mode and cap."""
    table = Table(title=escape(run_title(summary)))
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def short_numbers(summary: Summary) -> Numbers:
    """Return the most important numbers of a run, for 80 columns."""
    fidelity = summary.get("fidelity")
    compared = fidelity is not None and fidelity["reason"] is None
    actuations = summary.get("actuations")
    return (
        _lost(summary),
        *([_lost_of("actuations", actuations)] if actuations is not None else ()),
        longest_burst(summary, summary["longest_loss_burst"]),
        _forced(summary),
        *_intervals(summary),
        *_norms(summary),
        *_lateness(summary),
        *_other_clocks(summary),
        *_replay_rows(summary.get("replay")),
        *([next(summary_rows(fidelity))] if compared else ()),
    )


def loss_and_interval_rows(summary: Summary) -> Numbers:
    """Return losses, the longest loss burst, and inter-event times."""
    return (
        _lost(summary),
        longest_burst(summary, summary["longest_loss_burst"]),
        *_intervals(summary),
    )


def key_numbers(summary: Summary) -> Numbers:
    """Return all numbers of a run."""
    return (
        ("transmissions", str(summary["events"])),
        ("deliveries", str(summary["deliveries"])),
        *_losses(summary),
        *_intervals(summary),
        *_norms(summary),
        *_record(summary),
        *_watchdog(summary["watchdog"]),
        *(linearisation_rows(found) if (found := summary.get("linearisation")) else ()),
        *_estimation(summary["estimation"]),
        *_disturbances(summary["disturbances"]),
        *_replay_rows(summary.get("replay")),
        *summary_rows(summary.get("fidelity")),
    )


def _losses(summary: Summary) -> Iterator[tuple[str, str]]:
    yield _forced(summary)
    yield _lost(summary)
    if (rate := summary["loss_expected"]) is not None:
        yield "  expected loss rate with the cap", f"{100 * rate:.3g} %"
    causes = summary["drops_by_cause"]
    if set(causes) - {"dropped"}:
        for cause, count in causes.items():
            yield f"  of these {cause.replace('_', ' ')}", str(count)
    for name in ("acknowledgements", "actuations"):
        if (sent := summary.get(name)) is not None:
            yield name, str(sent["sent"])
            yield _lost_of(name, sent)
            yield f"longest loss burst of {name}", str(sent["longest_loss_burst"])
    yield longest_burst(summary, summary["longest_loss_burst"])
    causes = [one["cause"] for one in summary["assumption_violations"]]
    yield "loss bursts beyond M − 1", str(causes.count("dropouts"))
    for constraint in summary.get("constraints", ()):
        yield f"violations of {constraint}", str(causes.count(constraint))


def _lost_of(name: str, sent: Mapping[str, int]) -> tuple[str, str]:
    return f"{name} lost", f"{sent['lost']} ({ratio(sent['lost'], sent['sent'])})"


def _lost(summary: Summary) -> tuple[str, str]:
    lost = summary["drops"]
    return "lost in the network", f"{lost} ({ratio(lost, lost + summary['deliveries'])})"


def longest_burst(summary: Summary, longest: int) -> tuple[str, str]:
    """Return the row of the longest loss burst, with the most consecutive losses allowed."""
    cap = summary["mansd"]
    words = [f"mansd {cap}", *summary.get("constraints", ())]
    limit = settings_of(" ".join(words)).longest_burst
    if limit != cap:
        return f"longest loss burst (at most {limit} allowed)", str(longest)
    return f"longest loss burst (cap M − 1 = {cap})", str(longest)


def _forced(summary: Summary) -> tuple[str, str]:
    return "deliveries forced by the guarantee", str(summary["forced_deliveries"])


def _intervals(summary: Summary) -> Iterator[tuple[str, str]]:
    yield "shortest inter-event time", seconds(summary["inter_event_min_s"])
    yield "median inter-event time", seconds(summary["inter_event_median_s"])
    yield "median time between deliveries", seconds(summary["inter_delivery_median_s"])


def _norms(summary: Summary) -> Iterator[tuple[str, str]]:
    yield "‖x‖ at the start", number(summary["initial_state_norm"])
    yield "‖x‖ at the end", number(summary["final_state_norm"])
    errors = (summary["sup_e_s_norm"], summary["sup_e_c_norm"])
    yield "maximum ‖e_s‖, ‖e_c‖", ", ".join(map(number, errors))


def _record(summary: Summary) -> Iterator[tuple[str, str]]:
    yield "numerical check of x_c − x_s (I1)", number(summary["identity_residual_relative"])
    if (until_s := summary.get("judged_until_s")) is not None:
        yield "claims checked until", seconds(until_s)
    yield "missing samples", str(summary["missing_samples"])
    yield "lost elsewhere (kernel)", str(summary["unintended_losses"])
    yield from _clocks(summary)
    for one in summary["restarts"]:
        yield f"{one['process']} was restarted", away(one)
    yield from changes_in(summary)


def _clocks(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the largest bound of a clock's error, if it is recorded."""
    error_s = (summary.get("conditions") or {}).get("clock_error_s")
    if error_s is not None:
        yield "largest bound of a clock's error", duration(error_s)


def _other_clocks(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the same of a run on hosts with different clocks."""
    if (summary.get("conditions") or {}).get("clock_error_s"):
        yield from _clocks(summary)


def _lateness(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the latency of updates and the missed deadlines of a live run."""
    if latency := summary["latency_us"]:
        quantiles = " / ".join(whole(latency[key]) for key in ("p50", "p99"))
        yield "sensor-to-controller latency p50 / p99", f"{quantiles} µs"
    if late := summary["lateness_us"]:
        worst = max(late, key=lambda role: late[role]["late_steps"])
        missed, steps = late[worst]["late_steps"], late[worst]["steps"]
        if missed:
            yield "most deadlines missed", f"{worst}, {missed} of {steps}"
        else:
            yield "deadlines missed", "none"


def changes_in(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the changes during the run, each with its time."""
    for one in summary["changes"]:
        yield f"changed at {one['t_s']:.3f} s", one["what"]


def interval_of(claim: dict[str, Any]) -> str:
    """Return the interval of a claim; empty for the whole run."""
    from_s, until_s = claim["from_s"], claim["until_s"]
    if from_s == 0 and until_s is None:
        return ""
    return f"from {from_s:.3f} s " + ("on" if until_s is None else f"to {until_s:.3f} s")


def away(restart: dict[str, Any]) -> str:
    """Return the interval in which a process was down, and the reason."""
    since, until = (seconds(restart[key]) for key in ("last_s", "first_s"))
    why = (restart["what"] or "").partition(": ")[2]
    when = f"at {until}" if restart["last_s"] is None else f"down from {since} to {until}"
    return f"{when}: {why}" if why else when


def _watchdog(found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if trips := found["trips"]:
        times = "once" if trips == 1 else f"{trips} times"
        first, total = seconds(found["first_s"]), seconds(found["total_s"])
        yield "watchdog: newest actuation too old", f"{times}, first at {first}, {total} in total"
        yield "  policy applied", found["policy"]


def _estimation(found: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if found is not None:
        what = f"estimated ({found['observer']})" if found["observer"] else "measured with noise"
        errors = (found["max"], found["sup_e_c_norm"])
        yield (
            f"state {what}: RMS ‖x̂ − x‖ in the second half", number(found["rms_second_half"])
        )  # fmt: skip
        yield "  predicted for an exact model", number(found["expected_rms"])
        yield "maximum ‖x̂ − x‖, ‖x_c − x‖", ", ".join(map(number, errors))


def _disturbances(found: list[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    for one in found:
        sizes = f"{number(one['rms'])}, {number(one['max'])}"
        yield f"disturbance at the {one['at']}: RMS, maximum", sizes


def print_claims(console: Console, summary: Summary) -> None:
    """Print the claims about a run and their verdicts."""
    claims = summary.get("claims")
    if not claims:
        return
    table = Table(title="claims checked against this run")
    for heading in claim_headings(claims):
        table.add_column(heading, justify="right" if heading == "share used" else "left")
    for (*cells, verdict), colour in claim_rows(claims):
        table.add_row(*map(escape, cells), Text(verdict, colour))
    console.print(table)
    if any(claim["ratio"] is not None for claim in claims):
        console.print(
            "[dim]share used: largest share of the bound reached during the run; 100 % is normal "
            "for a bound that is computed from the run itself. Sources: (I1) and certificates, "
            "docs/theory.md; eq:... and theorems, the paper[/]"
        )
    sources: dict[tuple[str, str], list[str]] = {}
    for claim in claims:
        if claim["verdict"] != "held" and claim["why"]:
            sources.setdefault((claim["verdict"], claim["why"]), []).append(claim["source"])
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
        since = "" if claim["since_s"] is None else f" since {claim['since_s']:.3f} s"
        cells = (
            claim["source"], claim["bound"],
            *([interval_of(claim)] if has_interval else []),
            NONE if claim["ratio"] is None else f"{100 * claim['ratio']:.3g} %",
            claim["verdict"] + since,
        )  # fmt: skip
        yield ClaimRow(cells, _CLAIM_COLOURS[claim["verdict"]])


_CLAIM_COLOURS = {
    "held": "green", "violated": "bold red", "void": "yellow", "not applicable": "dim",
}  # fmt: skip


def _replay_rows(verdict: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if verdict is None:
        return
    if verdict["bit_exact"] is None:
        word = "not possible"
    elif verdict["bit_exact"]:
        word = f"bit-exact, {verdict['inputs']:,} inputs"
    else:
        first = verdict["first_difference"]
        word = f"differs: {first['table']}, row {first['row']}, {first['column']}"
    yield "replay", word if verdict.get("complete", True) else f"{word} (record incomplete)"


def _timing_table(summary: Summary) -> Table:
    table = Table(title="timing in µs of wall time (missed: deadlines missed)")
    for heading in ("", *TIMING_HEADINGS):
        table.add_column(heading, justify="right" if heading else "left")
    for row in timing_rows(summary):
        table.add_row(*row)
    return table


def timing_rows(summary: Summary) -> Iterator[tuple[str, ...]]:
    """Yield the lateness of each process, and the latency; their columns: TIMING_HEADINGS."""
    for role, late in summary["lateness_us"].items():
        counts = str(late["steps"]), str(late["late_steps"])
        yield f"{role} lateness", *(whole(late[key]) for key in _QUANTILES), *counts
    if latency := summary["latency_us"]:
        quantiles = (whole(latency[key]) for key in _QUANTILES)
        yield "sensor-to-controller latency", *quantiles, str(latency["updates"]), ""


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
