"""Tables of a run: key numbers, timing, claims."""

from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.analysis.model_comparison import linearisation_rows
from cosim.analysis.run_summary import Summary
from cosim.output.assumptions_table import print_assumptions
from cosim.output.fidelity_table import summary_rows
from noack.core.number_format import NONE, number, ratio, seconds, whole

Numbers = tuple[tuple[str, str], ...]
"""Quantities and their values, as text."""
_QUANTILES = ("p50", "p99", "p999", "max")


def print_details(console: Console, summary: Summary) -> None:
    """Print everything that a summary has: numbers, timing, assumptions, claims."""
    console.print(number_table(summary, key_numbers(summary)))
    if summary["lateness_us"]:  # none in virtual time
        console.print(_timing_table(summary))
        _print_realtime(console, summary["realtime"])
    console.print("the paper's assumptions for this scenario:")
    print_assumptions(console, summary["assumptions"])
    print_claims(console, summary)


def number_table(summary: Summary, rows: Numbers) -> Table:
    """Return a run's numbers as a table; its title names scenario, mode and cap."""
    kind = summary.get("kind", "live")
    how = "" if kind == "live" else f", {kind}"
    title = f"{summary['scenario']}, {_mode(summary)}, M − 1 = {summary['mansd']}{how}"
    table = Table(title=escape(title))
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def short_numbers(summary: Summary) -> Numbers:
    """Return the most important numbers of a run, for 80 columns."""
    lost, longest, *intervals = loss_and_interval_rows(summary)
    return (
        lost,
        longest,
        _forced(summary),
        *intervals,
        *_norms(summary),
        *_lateness(summary),
        *_replay_rows(summary.get("replay")),
        *_ideal_difference(summary.get("fidelity")),
    )


def loss_and_interval_rows(summary: Summary) -> Numbers:
    """Return losses, the longest loss burst, and inter-event times."""
    return _lost(summary), _longest_burst(summary), *_intervals(summary)


def key_numbers(summary: Summary) -> Numbers:
    """Return all numbers of a run."""
    return (
        ("transmissions", str(summary["events"])),
        ("deliveries", str(summary["deliveries"])),
        _forced(summary),
        _lost(summary),
        *_expected(summary.get("loss_expected")),
        *_causes(summary),
        *_acknowledgements(summary.get("acknowledgements")),
        _longest_burst(summary),
        ("loss bursts beyond M − 1", str(_bursts_beyond_mansd(summary))),
        *_intervals(summary),
        *_norms(summary),
        ("numerical check of x_c − x_s (I1)", number(summary["identity_residual_relative"])),
        *_judged_until(summary.get("judged_until_s")),
        ("missing samples", str(summary["missing_samples"])),
        ("lost elsewhere (kernel)", str(summary["unintended_losses"])),
        *_restarts(summary.get("restarts")),
        *changes_in(summary),
        *_watchdog(summary.get("watchdog")),
        *(linearisation_rows(found) if (found := summary.get("linearisation")) else ()),
        *_estimation(summary.get("estimation")),
        *_disturbances(summary.get("disturbances")),
        *_replay_rows(summary.get("replay")),
        *summary_rows(summary.get("fidelity")),
    )  # fmt: skip


def _bursts_beyond_mansd(summary: Summary) -> int:
    return sum(one["cause"] == "dropouts" for one in summary["assumption_violations"])


def _lost(summary: Summary) -> tuple[str, str]:
    lost = summary["drops"]
    return "lost in the network", f"{lost} ({ratio(lost, lost + summary['deliveries'])})"


def _longest_burst(summary: Summary) -> tuple[str, str]:
    return f"longest loss burst (cap M − 1 = {summary['mansd']})", str(
        summary["longest_loss_burst"]
    )


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


def _ideal_difference(fidelity: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if fidelity is not None and fidelity["reason"] is None:
        yield next(summary_rows(fidelity))


def _lateness(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the latency of updates and the missed deadlines of a live run."""
    if latency := summary["latency_us"]:
        quantiles = " / ".join(whole(latency[key]) for key in ("p50", "p99"))
        yield "sensor-to-controller latency p50 / p99", f"{quantiles} µs"
    late = summary["lateness_us"]
    if late:
        worst = max(late, key=lambda role: late[role]["late_steps"])
        missed, steps = late[worst]["late_steps"], late[worst]["steps"]
        if missed:
            yield "most deadlines missed", f"{worst}, {missed} of {steps}"
        else:
            yield "deadlines missed", "none"


def _causes(summary: Summary) -> Iterator[tuple[str, str]]:
    causes = summary.get("drops_by_cause") or {}
    if set(causes) - {"dropped"}:
        for cause, number in causes.items():
            yield f"  of these {cause.replace('_', ' ')}", str(number)


def _acknowledgements(found: dict[str, int] | None) -> Iterator[tuple[str, str]]:
    if found is not None:
        yield "acknowledgements", str(found["sent"])
        yield "  lost", f"{found['lost']} ({ratio(found['lost'], found['sent'])})"
        yield "  longest loss burst", str(found["longest_loss_burst"])


def _restarts(found: list[dict[str, Any]] | None) -> Iterator[tuple[str, str]]:
    for one in found or ():
        yield f"{one['process']} was restarted", away(one)


def changes_in(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the changes during the run, each with its time."""
    for one in summary.get("changes") or ():
        yield f"changed at {one['t_s']:.3f} s", one["what"]


def interval_of(claim: dict[str, Any]) -> str:
    """Return the interval of a claim; empty for the whole run."""
    from_s, until_s = claim.get("from_s") or 0.0, claim.get("until_s")
    if from_s == 0 and until_s is None:
        return ""
    return f"from {from_s:.3f} s " + ("on" if until_s is None else f"to {until_s:.3f} s")


def away(restart: dict[str, Any]) -> str:
    """Return the interval in which a process was down, and the reason."""
    since, until = (seconds(restart[key]) for key in ("last_s", "first_s"))
    why = (restart["what"] or "").partition(": ")[2]
    when = f"at {until}" if restart["last_s"] is None else f"down from {since} to {until}"
    return f"{when}: {why}" if why else when


def _watchdog(found: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if found is not None and found["trips"]:
        times = "once" if found["trips"] == 1 else f"{found['trips']} times"
        first, total = seconds(found["first_s"]), seconds(found["total_s"])
        yield "watchdog: newest actuation too old", f"{times}, first at {first}, {total} in total"
        yield "  policy applied", found["policy"]


def _estimation(found: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if found is not None:
        rms, expected = number(found["rms_second_half"]), number(found["expected_rms"])
        what = f"estimated ({found['observer']})" if found["observer"] else "measured with noise"
        yield f"state {what}: RMS ‖x̂ − x‖ in the second half", rms
        yield "  predicted for an exact model", expected
        yield (
            "maximum ‖x̂ − x‖, ‖x_c − x‖",
            f"{number(found['max'])}, {number(found['sup_e_c_norm'])}",
        )


def _judged_until(until_s: float | None) -> Iterator[tuple[str, str]]:
    if until_s is not None:
        yield "claims checked until", seconds(until_s)


def _expected(rate: float | None) -> Iterator[tuple[str, str]]:
    if rate is not None:
        yield "  expected loss rate with the cap", f"{100 * rate:.3g} %"


def _disturbances(found: list[dict[str, Any]] | None) -> Iterator[tuple[str, str]]:
    for one in found or ():
        what = f"disturbance at the {one['at']}: RMS, maximum"
        yield what, f"{number(one['rms'])}, {number(one['max'])}"


def print_claims(console: Console, summary: Summary) -> None:
    """Print the claims about a run and their verdicts."""
    claims = summary.get("claims")
    if not claims:
        return
    table = Table(title="claims checked against this run")
    parts = any(map(interval_of, claims))
    for heading in ("source", "claim", *(["interval"] if parts else []), "used", "verdict"):
        table.add_column(heading, justify="right" if heading == "used" else "left")
    for claim in claims:
        used = NONE if claim["ratio"] is None else f"{100 * claim['ratio']:.3g} %"
        since = "" if claim["since_s"] is None else f" since {claim['since_s']:.3f} s"
        colour = _CLAIM_COLOURS[claim["verdict"]]
        table.add_row(
            *(escape(claim[key]) for key in ("source", "bound")),
            *([interval_of(claim)] if parts else []),
            used,
            f"[{colour}]{claim['verdict']}{since}[/]",
        )
    console.print(table)
    if any(claim["ratio"] is not None for claim in claims):
        console.print(
            "[dim]used: largest share of the bound reached during the run; "
            "bounds on ‖e_c‖ that are computed from the run itself are tight[/]"
        )
    for verdict, why in dict.fromkeys((c["verdict"], c["why"]) for c in claims):
        if verdict != "held" and why:
            console.print(f"{verdict}: {_sources(claims, verdict, why)}: {why}",
                          highlight=False, markup=False)  # fmt: skip


def _sources(claims: list[dict[str, Any]], verdict: str, why: str) -> str:
    same = (c["source"] for c in claims if (c["verdict"], c["why"]) == (verdict, why))
    return "; ".join(dict.fromkeys(same))


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
        found = verdict["first_difference"]
        word = f"differs: {found['table']}, row {found['row']}, {found['column']}"
    yield "replay", word if verdict.get("complete", True) else f"{word} (record incomplete)"


def _timing_table(summary: Summary) -> Table:
    table = Table(title="timing in µs of wall time (missed: deadlines missed)")
    for heading in ("", "p50", "p99", "p99.9", "max", "count", "missed"):
        table.add_column(heading, justify="right" if heading else "left")
    for role, late in summary["lateness_us"].items():
        table.add_row(
            f"{role} lateness",
            *(whole(late[key]) for key in _QUANTILES),
            str(late["steps"]),
            str(late["late_steps"]),
        )
    latency = summary["latency_us"]
    table.add_row(
        "sensor-to-controller latency",
        *(whole(latency[key]) for key in _QUANTILES),
        str(latency["updates"]),
        "",
    )
    return table


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


def _mode(summary: Summary) -> str:
    return "model-based" if summary["mode"] == "model" else "zero-order hold"
