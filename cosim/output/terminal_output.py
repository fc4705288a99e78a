"""Terminal output about a run: its verdict and key numbers, or all tables; what is wrong; its files.

:func:`print_outcome` prints the texts of ``run_verdict.py`` with the tables of ``run_tables.py``.
"""

import re
import shlex
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import AssumptionPart, Claim, LoopSummary, RunSummary
from cosim.output.result_tables import KEY_VALUE, ResultTable, terminal_table
from cosim.output.run_tables import (
    LOOPS_CAPTION,
    badness,
    loops_table,
    network_rows,
    run_title,
    shares_network,
    short_numbers,
    summary_tables,
)
from cosim.output.run_verdict import Tone, VerdictLine, remarks, verdict
from cosim.record.run_directory import RECORDING_FILE, REPORT_FILE, file_of_loop
from noack.core.number_format import counted
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus

_GOOD, _DOUBTFUL, _BAD = "green", "yellow", "bold red"
_TONE_STYLES = {Tone.GOOD: _GOOD, Tone.DOUBTFUL: _DOUBTFUL, Tone.BAD: _BAD, Tone.NEUTRAL: ""}
_CLAIM_STYLES = {"held": _GOOD, "violated": _BAD, "void": _DOUBTFUL, "not applicable": "dim"}
_ASSUMPTION_STYLES: dict[str, str] = {
    AssumptionStatus.HOLDS: "green",
    AssumptionStatus.VIOLATED: "bold yellow",
    AssumptionStatus.IDEALISED: "dim",
    AssumptionStatus.NOT_NEEDED: "dim",
    AssumptionStatus.ASSUMED: "cyan",
}
_MOST_LOOPS, _MOST_REASONS = 12, 3
"""Loops in the table, and reasons below it, without --verbose."""
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")
"""A number in a reason."""


def print_outcome(console: Console, outcome: Outcome, *, verbose: bool = False) -> None:
    """Print the verdict, the key numbers, the remarks, and where to find more.

    Args:
        console: console for the output.
        outcome: outcome of the run, or of one of its loops.
        verbose: print all tables instead of the key numbers.
    """
    summary = outcome.summary
    for line in verdict(summary):
        print_line(console, line)
    if shares_network(summary):
        _print_loops(console, summary, verbose=verbose)
    else:
        _print_loop(console, summary, verbose=verbose)
    for where in _where(outcome, verbose=verbose):
        console.print(where, highlight=False, soft_wrap=True, markup=False)


def print_line(console: Console, line: VerdictLine) -> None:
    """Print a line of a verdict."""
    console.print(Text(line.text, _TONE_STYLES[line.tone]), soft_wrap=True)


def _print_loop(console: Console, summary: RunSummary, *, verbose: bool) -> None:
    if verbose:
        _print_details(console, summary)
    else:
        print_numbers(console, run_title(summary), short_numbers(summary))
    for remark in remarks(summary):
        start = "" if remark.neutral else "[bold yellow]warning:[/] "
        start = f"[{_BAD}]" if remark.severe else start
        console.print(start + escape(remark.text), highlight=False, soft_wrap=True)


def print_numbers(console: Console, title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print quantities and their values."""
    console.print(terminal_table(ResultTable("numbers", title, KEY_VALUE, rows)))


def _print_details(console: Console, summary: RunSummary) -> None:
    """Print everything that the summary of one loop has: numbers, timing, assumptions, claims."""
    (loop,), tables = summary.loops, {table.name: table for table in summary_tables(summary)}
    console.print(terminal_table(tables["numbers"]))
    if "timing" in tables:
        console.print(terminal_table(tables["timing"]))
        _print_realtime(console, loop.realtime)
    console.print("the paper's assumptions for this scenario:")
    print_assumptions(console, loop.assumptions)
    if "claims" in tables:
        _print_claims(console, tables["claims"], loop.claims)
    if "schedule" in tables:
        console.print(terminal_table(tables["schedule"]))


def _print_loops(console: Console, summary: RunSummary, *, verbose: bool) -> None:
    """Print the network and the loops; without ``verbose`` the worst only."""
    for line in _void_lines(summary.loops):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    print_numbers(console, f"network of {run_title(summary)}", network_rows(summary))
    loops, title = summary.loops, f"{len(summary.loops)} loops"
    if not verbose and len(loops) > _MOST_LOOPS:
        loops = sorted(loops, key=badness, reverse=True)[:_MOST_LOOPS]
        title += ", the worst first"
    console.print(terminal_table(loops_table(loops, title), dense=True))
    console.print(LOOPS_CAPTION, style="table.caption")
    if more := len(summary.loops) - len(loops):
        console.print(f"and {counted(more, 'more loop')}: --verbose shows all")


def _void_lines(loops: Sequence[LoopSummary]) -> list[str]:
    """Return why claims are void, and in which loops; nothing if that is in the verdict.

    Reasons that differ only in numbers are one.
    """
    reasons = defaultdict[str, list[tuple[str, str]]](list)
    for loop in loops:
        for why in sorted({claim.why for claim in loop.claims if claim.verdict == "void"}):
            reasons[_NUMBER.sub("#", why)].append((why, loop.name))
    if len(reasons) == 1:
        return []
    lines = list[str]()
    for alike in sorted(reasons.values(), key=lambda alike: -len({name for _, name in alike})):
        names = [*dict.fromkeys(name for _, name in alike)]
        where = names[0] if len(names) == 1 else f"{len(names)} loops"
        lines.append(f"void: {_with_ranges([why for why, _ in alike])} ({where})")
    more = len(lines) - _MOST_REASONS
    if more > 0:
        reasons_word = "reason" if more == 1 else "reasons"
        lines[_MOST_REASONS:] = [f"and {more} more {reasons_word}: the summaries of the loops have them"]
    return lines


def _with_ranges(texts: Sequence[str]) -> str:
    """Return one text for several that differ only in numbers."""
    ranges = list[str]()
    for numbers in zip(*(_NUMBER.findall(text) for text in texts), strict=True):
        low, high = min(numbers, key=float), max(numbers, key=float)
        ranges.append(low if low == high else f"{low} to {high}")
    following = iter(ranges)
    return _NUMBER.sub(lambda _: next(following), texts[0])


def _print_claims(console: Console, table: ResultTable, claims: Sequence[Claim]) -> None:
    """Print the claims about a loop and their verdicts."""
    left = [i for i, heading in enumerate(table.headings) if heading != "share used"]
    console.print(terminal_table(table, left=left, styles=_CLAIM_STYLES))
    if any(claim.ratio is not None for claim in claims):
        console.print(
            "[dim]share used: largest share of the bound reached during the run; a bound "
            "computed from the run itself is reached by construction. ε: the trigger's floor; t_k: "
            "the k-th event; H = Â + B̂K, or 0 with a hold; β̃: bound of the sensor's error; W: "
            "trigger.weight. Sources: (I1) and "
            "certificates, docs/theory.md; eq:... and theorems, the paper[/]"
        )
    sources: dict[tuple[str, str], list[str]] = {}
    for claim in claims:
        if claim.verdict != "held" and claim.why:
            sources.setdefault((claim.verdict, claim.why), []).append(claim.origin)
    for (word, reason), claim_sources in sources.items():
        text = f"{word}: {'; '.join(dict.fromkeys(claim_sources))}: {reason}"
        console.print(text, highlight=False, markup=False)


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


def print_assumptions(console: Console, assumptions: Sequence[Assumption | AssumptionPart]) -> None:
    """Print assumptions with their verdicts."""
    table = Table.grid(padding=(0, 2))
    for assumption in assumptions:
        source = assumption.source if assumption.source.startswith("(") else f"({assumption.source})"
        text = escape(f"{assumption.what} {source}: {assumption.why}")
        table.add_row(Text(assumption.verdict, _ASSUMPTION_STYLES.get(assumption.verdict, "")), text)
    console.print(table)


def _where(outcome: Outcome, *, verbose: bool) -> Iterator[str]:
    """Yield the files of a run, or one line with the commands that show them."""
    run_dir, loop = outcome.run_dir, outcome.loop
    argument = shlex.quote(str(run_dir))
    report = run_dir / file_of_loop(REPORT_FILE, loop)
    of_loop = "" if loop is None else f" --loop {loop}"
    if shares_network(outcome.summary):
        yield f"one loop: {_program()} summary {argument} --loop NAME"
    if not verbose:
        page = f"{report} and " if report.is_file() else ""
        yield f"more: {page}{_program()} summary {argument}{of_loop} --verbose"
        return
    yield f"run directory  {run_dir}"
    if report.is_file():
        yield f"report         {report}"
    target = run_dir / RECORDING_FILE if loop is None else f"{argument}{of_loop}"
    if (run_dir / RECORDING_FILE).is_file():
        yield f"view           {_program()} view {target}"


def _program() -> str:
    """Return the name under which noack was started, for the commands that are shown."""
    program = Path(sys.argv[0])
    if shutil.which(program.name) == str(program):
        return program.name
    inside = program.is_absolute() and program.is_relative_to(Path.cwd())
    return str(program.relative_to(Path.cwd()) if inside else program)
