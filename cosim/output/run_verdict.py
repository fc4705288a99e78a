"""Terminal output at the end of a run: a verdict of three lines, tables, the run's files."""

import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.markup import escape
from rich.text import Text

from cosim.analysis.run_summary import Outcome
from cosim.analysis.summary_model import Claim, ExitPart, FidelityPart, RunSummary
from cosim.output.network_table import print_loops
from cosim.output.remarks import remarks
from cosim.output.run_tables import number_table, print_details, run_title, short_numbers
from cosim.record.run_directory import RECORDING_FILE, REPORT_FILE
from noack.core.errors import ExitStatus
from noack.runtime.life_cycle import HORIZON

GOOD, DOUBTFUL, BAD, NEUTRAL = "green", "yellow", "bold red", ""
_CLAIMS = {"violated": BAD, "void": DOUBTFUL, "not applicable": NEUTRAL}
"""Styles of verdicts other than "held", the worst first."""
_NAMED = 3
"""Largest number of claims of a verdict that are named."""


class VerdictLine(NamedTuple):
    """A line of the verdict."""

    text: str
    style: str
    """Name of a style of rich."""


def verdict(summary: RunSummary) -> tuple[VerdictLine, ...]:
    """Return how the run ended, the transmissions of its loops, and their claims."""
    loops = summary.loops
    events, delivered = (
        sum(getattr(one, key) for one in loops) for key in ("events", "deliveries")
    )
    ideal = None
    if len(loops) == 1 and isinstance(found := loops[0].fidelity, FidelityPart):
        ideal = found.events_ideal
    return (
        ending_line(summary.exit, summary.reached_s, summary.horizon_s),
        transmission_line(events, delivered, ideal),
        _claims([claim for one in loops for claim in one.claims]),
    )


def ending_line(end: ExitPart, reached_s: float, horizon_s: float) -> VerdictLine:
    """Return how a run ended."""
    reached = f"{reached_s:g} s"
    reached_of = f"{reached} of {horizon_s:g} s"
    if end.status == ExitStatus.OK:
        why = "" if end.reason == HORIZON else f": {end.reason}"
        return VerdictLine(f"completed {reached}{why}", GOOD)
    if end.status == ExitStatus.FAILED:
        return VerdictLine(f"failed after {reached_of}: {end.reason}", BAD)
    return VerdictLine(f"stopped after {reached_of}: {end.reason}", DOUBTFUL)


def transmission_line(events: int, deliveries: int, ideal: int | None = None) -> VerdictLine:
    """Return the numbers of transmissions and deliveries, and that of the ideal loop."""
    beside = "" if ideal is None else f" (ideal loop: {ideal})"
    return VerdictLine(f"{events} transmissions{beside}, {deliveries} delivered", NEUTRAL)


def _claims(claims: Sequence[Claim]) -> VerdictLine:
    """Count the claims by verdict, each with its first reason."""
    if not claims:
        return VerdictLine("claims: none", NEUTRAL)
    counts = Counter(str(claim.verdict) for claim in claims)
    parts, style = [f"claims: {counts['held']} of {len(claims)} held"], GOOD
    for name, colour in _CLAIMS.items():
        if counts[name]:
            style = colour if style == GOOD else style
            parts.append(f"{counts[name]} {name}{_reason(claims, name)}")
    return VerdictLine(", ".join(parts), style)


def _reason(claims: Sequence[Claim], name: str) -> str:
    """Return the first reason of a verdict, in brackets; with it, unless void, which claims."""
    concerned = [claim for claim in claims if claim.verdict == name]
    why = next((claim.why for claim in concerned if claim.why), "")
    what = [] if name == "void" else list(dict.fromkeys(claim.what for claim in concerned))
    more = [f"{len(what) - _NAMED} more"] if len(what) > _NAMED else []
    which = "; ".join([*what[:_NAMED], *more])
    return f" ({': '.join(filter(None, (which, why)))})" if which or why else ""


def print_outcome(console: Console, outcome: Outcome, *, verbose: bool = False) -> None:
    """Print the verdict, the key numbers, the remarks, and where to find more.

    Args:
        console: console for the output.
        outcome: outcome of the run, or of one of its loops.
        verbose: print all tables instead of the key numbers.
    """
    summary = outcome.summary
    for line in verdict(summary):
        console.print(Text(line.text, line.style), soft_wrap=True)
    if len(summary.loops) > 1:
        print_loops(console, summary, verbose=verbose)
    else:
        _print_loop(console, summary, verbose=verbose)
    for where in _where(outcome, verbose=verbose):
        console.print(where, highlight=False, soft_wrap=True, markup=False)


def _print_loop(console: Console, summary: RunSummary, *, verbose: bool) -> None:
    if verbose:
        print_details(console, summary)
    else:
        console.print(number_table(run_title(summary), short_numbers(summary)))
    for remark in remarks(summary):
        start = f"[{BAD}]" if remark.severe else "[bold yellow]warning:[/] "
        console.print(start + escape(remark.text), highlight=False, soft_wrap=True)


def _where(outcome: Outcome, *, verbose: bool) -> Iterator[str]:
    """Yield the files of a run, or one line with the commands that show them."""
    run_dir, report = outcome.run_dir, outcome.run_dir / REPORT_FILE
    if len(outcome.summary.loops) > 1:
        yield f"one loop: {_program()} summary {run_dir} --loop NAME"
    if not verbose:
        page = f"{report} and " if report.is_file() else ""
        yield f"more: {page}{_program()} summary {run_dir} --verbose"
        return
    yield f"run directory  {run_dir}"
    if report.is_file():
        yield f"report         {report}"
    yield f"view           {_program()} view {run_dir / RECORDING_FILE}"


def _program() -> str:
    """Return the name under which noack was started, for the commands that are shown."""
    program = Path(sys.argv[0])
    if shutil.which(program.name) == str(program):
        return program.name
    inside = program.is_absolute() and program.is_relative_to(Path.cwd())
    return str(program.relative_to(Path.cwd()) if inside else program)
