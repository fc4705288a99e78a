"""The tables that a person sees at the end of a run."""

import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.conclude import Outcome
from cosim.fidelity_table import summary_rows
from cosim.linearisation import said
from cosim.run_dir import RECORDING_FILE, REPORT_FILE
from cosim.summary import Summary
from noack.theory.assumptions import Verdict

_QUANTILES = ("p50", "p99", "p999", "max")


def print_outcome(console: Console, outcome: Outcome) -> None:
    """Print the tables at the end of a run."""
    summary = outcome.summary
    console.print(_run_table(summary))
    if summary["lateness_us"]:  # in virtual time nothing is late
        console.print(_timing_table(summary))
        _print_realtime(console, summary["realtime"])
    print_assumptions(console, summary["assumptions"])
    print_claims(console, summary)
    for violation in summary["assumption_violations"]:
        console.print(
            f"[bold red]assumption violated[/] at t = {violation['t_s']:.3f} s, "
            f"seen by {violation['process']}: {escape(violation['what'])}"
        )
    for warning in warnings_of(summary):
        console.print(f"[bold yellow]warning:[/] {escape(warning)}", highlight=False)
    if outcome.status:
        console.print(f"[bold red]the run failed:[/] {escape(outcome.reason)}")
    console.print(f"in short       {_in_short(summary)}", highlight=False, soft_wrap=True)
    console.print(
        f"run directory  {outcome.run_dir}", highlight=False, soft_wrap=True, markup=False
    )
    if (report := outcome.run_dir / REPORT_FILE).is_file():
        console.print(f"report         {report}", highlight=False, soft_wrap=True, markup=False)
    console.print(
        f"look at it     {_program()} view {outcome.run_dir / RECORDING_FILE}",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )


def _in_short(summary: Summary) -> str:
    """How far the run came, and what became of its claims."""
    verdicts = Counter(claim["verdict"] for claim in summary.get("claims") or ())
    found = [
        f"[{colour}]{verdicts[name]} {name}[/]"
        for name, colour in _CLAIM_COLOURS.items()
        if verdicts[name]
    ]
    return f"{summary['reached_s']:g} s; claims: {', '.join(found) or 'none'}"


def _run_table(summary: Summary) -> Table:
    simulated = ", simulated" if summary.get("kind") == "simulated" else ""
    title = f"{summary['scenario']}, {_mode(summary)}, M − 1 = {summary['mansd']}{simulated}"
    table = Table(title=title)
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for row in key_numbers(summary):
        table.add_row(*map(escape, row))
    return table


def key_numbers(summary: Summary) -> tuple[tuple[str, str], ...]:
    """What happened in a run: each quantity and its value, as a person reads them."""
    events, deliveries = summary["events"], summary["deliveries"]
    arrived = summary["drops"] + deliveries
    return (
        ("events (transmissions)", str(events)),
        ("deliveries", str(deliveries)),
        ("  of these forced (t_0 or cap)", str(summary["forced_deliveries"])),
        ("lost in the network", f"{summary['drops']} ({_percent(summary['drops'], arrived)})"),
        *_expected(summary.get("loss_expected"), summary["mansd"]),
        *_causes(summary),
        *_acknowledgements(summary.get("acknowledgements")),
        ("longest drop run", f"{summary['longest_drop_run']} (at most {summary['mansd']})"),
        ("drop runs beyond M − 1", str(len(summary["assumption_violations"]))),
        ("shortest inter-event time", _seconds(summary["inter_event_min_s"])),
        ("median inter-event time", _seconds(summary["inter_event_median_s"])),
        ("median time between deliveries", _seconds(summary["inter_delivery_median_s"])),
        ("‖x‖ at the start", _number(summary["initial_state_norm"])),
        ("‖x‖ at the end", _number(summary["final_state_norm"])),
        ("largest ‖e_s‖, ‖e_c‖",
         f"{_number(summary['sup_e_s_norm'])}, {_number(summary['sup_e_c_norm'])}"),
        ("identity (I1), relative residual", _number(summary["identity_residual_relative"])),
        ("missing samples", str(summary["missing_samples"])),
        ("lost outside the emulator", str(summary["lost_outside_netem"])),
        *_restarts(summary.get("restarts")),
        *changes_in(summary),
        *_watchdog(summary.get("watchdog")),
        *(said(found) if (found := summary.get("linearisation")) else ()),
        *_estimation(summary.get("estimation")),
        *_disturbances(summary.get("disturbances")),
        *_replay_rows(summary.get("replay")),
        *summary_rows(summary.get("fidelity")),
    )  # fmt: skip


def _causes(summary: Summary) -> Iterator[tuple[str, str]]:
    causes = summary.get("drops_by_cause") or {}
    if set(causes) - {"dropped"}:
        for cause, number in causes.items():
            yield f"  of these {cause.replace('_', ' ')}", str(number)


def _acknowledgements(found: dict[str, int] | None) -> Iterator[tuple[str, str]]:
    if found is not None:
        yield "acknowledgements", str(found["sent"])
        yield "  of these lost", f"{found['lost']} ({_percent(found['lost'], found['sent'])})"
        yield "  longest run of losses", str(found["longest_loss_run"])


def _restarts(found: list[dict[str, Any]] | None) -> Iterator[tuple[str, str]]:
    for one in found or ():
        yield f"{one['process']} was started anew", away(one)


def changes_in(summary: Summary) -> Iterator[tuple[str, str]]:
    """What was changed while the run went on, and from when on."""
    for one in summary.get("changes") or ():
        yield f"changed at {one['t_s']:.3f} s", one["what"]


def interval_of(claim: dict[str, Any]) -> str:
    """Of which time something is claimed, if not of the whole run."""
    from_s, until_s = claim.get("from_s") or 0.0, claim.get("until_s")
    if from_s == 0 and until_s is None:
        return ""
    return f"from {from_s:.3f} s " + ("on" if until_s is None else f"to {until_s:.3f} s")


def away(restart: dict[str, Any]) -> str:
    """From when to when somebody was away, and why."""
    since, until = (_seconds(restart[key]) for key in ("last_s", "first_s"))
    why = (restart["what"] or "").partition(": ")[2]
    when = f"at {until}" if restart["last_s"] is None else f"away from {since} to {until}"
    return f"{when}: {why}" if why else when


def _watchdog(found: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if found is not None and found["trips"]:
        times = "once" if found["trips"] == 1 else f"{found['trips']} times"
        first, total = _seconds(found["first_s"]), _seconds(found["total_s"])
        yield "actuations too old (watchdog)", f"{times}, first at {first}, {total} in all"
        yield "  policy then", found["policy"]


def _estimation(found: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if found is not None:
        rms, expected = _number(found["rms_second_half"]), _number(found["expected_rms"])
        what = f"estimated ({found['observer']})" if found["observer"] else "measured with noise"
        yield f"state {what}: RMS ‖x̂ − x‖, second half", rms
        yield "  in the steady state, were the plant the model", expected
        yield (
            "largest ‖x̂ − x‖, ‖x_c − x‖",
            f"{_number(found['max'])}, {_number(found['sup_e_c_norm'])}",
        )


def _expected(rate: float | None, mansd: int) -> Iterator[tuple[str, str]]:
    if rate is not None:
        yield f"  in the long run, at most {mansd} in a row", f"{100 * rate:.3g} %"


def _disturbances(found: list[dict[str, Any]] | None) -> Iterator[tuple[str, str]]:
    for one in found or ():
        what = f"disturbance at the {one['at']}, RMS, largest"
        yield what, f"{_number(one['rms'])}, {_number(one['max'])}"


def print_claims(console: Console, summary: Summary) -> None:
    """Print what was claimed of a run, and what became of it."""
    claims = summary.get("claims")
    if not claims:
        return
    undisturbed = summary.get("kind", "live") == "live" and not summary.get("restarts")
    if undisturbed and any("felt after" in c["why"] or " old" in c["why"] for c in claims):
        console.print(
            "this machine was late, which voids claims that do not allow for it: a greater "
            "certificate.late_periods does, where it can be certified; noack simulate is never late"
        )
    table = Table(title="claims, and what this run says of them")
    parts = any(map(interval_of, claims))
    for heading in ("source", "claim", *(["of the time"] if parts else []), "used", "verdict"):
        table.add_column(heading, justify="right" if heading == "used" else "left")
    for claim in claims:
        used = "-" if claim["ratio"] is None else f"{100 * claim['ratio']:.3g} %"
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
            "[dim]used: how near the run came to the bound, at its nearest; "
            "those on ‖e_c‖ that are made of the run itself are tight[/]"
        )
    for verdict, why in dict.fromkeys((c["verdict"], c["why"]) for c in claims):
        if verdict != "held" and why:
            console.print(f"{verdict}: {_sources(claims, verdict, why)}: {why}",
                          highlight=False, markup=False)  # fmt: skip


def _sources(claims: list[dict[str, Any]], verdict: str, why: str) -> str:
    same = (c["source"] for c in claims if (c["verdict"], c["why"]) == (verdict, why))
    return "; ".join(dict.fromkeys(same))


_CLAIM_COLOURS = {"held": "green", "violated": "bold red", "void": "yellow"}


def _replay_rows(verdict: dict[str, Any] | None) -> Iterator[tuple[str, str]]:
    if verdict is None:
        return
    if verdict["bit_exact"] is None:
        word = "not possible"
    elif verdict["bit_exact"]:
        word = f"bit-exact, {verdict['inputs']:,} inputs"
    else:
        found = verdict["first_difference"]
        word = f"differs: {found['table']} row {found['row']} {found['column']}"
    yield "replay", word if verdict.get("complete", True) else f"{word} (record incomplete)"


def _timing_table(summary: Summary) -> Table:
    table = Table(title="timing, wall µs")
    for heading in ("", "p50", "p99", "p99.9", "max", "count", "late"):
        table.add_column(heading, justify="right" if heading else "left")
    for role, late in summary["lateness_us"].items():
        table.add_row(
            f"{role} lateness",
            *(_whole(late[key]) for key in _QUANTILES),
            str(late["steps"]),
            str(late["late_steps"]),
        )
    latency = summary["latency_us"]
    table.add_row(
        "event → update", *(_whole(latency[key]) for key in _QUANTILES), str(latency["updates"]), ""
    )
    return table


def _print_realtime(console: Console, realtime: dict[str, dict[str, str]]) -> None:
    """One line for all processes that were granted the same."""
    roles_by_settings: dict[str, list[str]] = {}
    for role in sorted(realtime):
        verdicts = realtime[role]
        text = ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items())
        if set(verdicts.values()) == {"granted"}:
            text = "all granted"
        roles_by_settings.setdefault(text, []).append(role)
    for text, roles in roles_by_settings.items():
        whose = "" if len(roles) == len(realtime) else f" of {', '.join(roles)}"
        console.print(f"real-time settings{whose}: {text}", highlight=False, markup=False)


def print_assumptions(console: Console, assumptions: list[dict[str, str]]) -> None:
    """Print the paper's assumptions with their verdicts."""
    table = Table.grid(padding=(0, 2))
    for assumption in assumptions:
        holds = assumption["verdict"] == Verdict.HOLDS
        table.add_row(
            "[green]holds[/]" if holds else "[yellow]violated[/]",
            escape(f"{assumption['what']} ({assumption['source']}): {assumption['why']}"),
        )
    console.print("the paper's assumptions, for this scenario:")
    console.print(table)


def warnings_of(summary: Summary) -> Iterator[str]:
    """What a person should know before trusting the numbers of a run, a sentence each."""
    late = summary["lateness_us"].get("plant")
    if late and late["steps"] and late["late_steps"] > 0.01 * late["steps"]:
        share = 100 * late["late_steps"] / late["steps"]
        yield f"{share:.0f} % of the plant's steps were late: lower speed or plant.rate_hz"
    first, last = summary["initial_state_norm"], summary["final_state_norm"]
    if first is not None and last is not None and last > 10 * first > 0:
        yield f"‖x‖ grew from {first:.3g} to {last:.3g}: the loop diverges"


def _mode(summary: Summary) -> str:
    return "model-based" if summary["mode"] == "model" else "zero-order hold"


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %" if whole else "-"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} s"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _whole(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _program() -> str:
    """How the person called us, so that the next command can be typed alike."""
    program = Path(sys.argv[0])
    inside = program.is_absolute() and program.is_relative_to(Path.cwd())
    return str(program.relative_to(Path.cwd()) if inside else program)
