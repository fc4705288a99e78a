"""A run as a document: its verdict and key numbers, or all tables; what is wrong; its files.

:func:`run_document` has the texts of ``run_verdict.py`` and the tables of ``run_tables.py``.
"""

import re
import shlex
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import ClaimVerdict, LoopSummary, RunSummary
from cosim.output.claim_words import claim_reason
from cosim.output.conformance_words import conformance_text
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
from cosim.output.run_verdict import remarks, verdict
from cosim.record.run_directory import RECORDING_FILE, REPORT_FILE, file_of_loop
from netem.core.number_format import counted
from netem.output.document import Block, Document, Sentence, SentenceRole
from netem.output.result_tables import KEY_VALUE, ResultTable, Tone
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus

_ASSUMPTION_TONES: dict[str, Tone] = {
    AssumptionStatus.HOLDS: Tone.GOOD,
    AssumptionStatus.VIOLATED: Tone.DOUBTFUL,
    AssumptionStatus.IDEALISED: Tone.QUIET,
    AssumptionStatus.NOT_NEEDED: Tone.QUIET,
}
_MOST_LOOPS, _MOST_REASONS = 12, 3
"""Loops in the table, and reasons below it, without --verbose."""
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")
"""A number in a reason."""


def run_document(outcome: Outcome, *, verbose: bool = False) -> Document:
    """Return the verdict, the key numbers, the remarks, and where to find more.

    Args:
        outcome: outcome of the run, or of one of its loops.
        verbose: with all tables instead of the key numbers.
    """
    summary = outcome.summary
    if shares_network(summary):
        blocks = _loops(summary, verbose=verbose)
    else:
        numbers = ResultTable("numbers", run_title(summary), KEY_VALUE, short_numbers(summary))
        blocks = [*(_details(summary) if verbose else [numbers]), *remarks(summary)]
    where = (Sentence(text=line) for line in _where(outcome, verbose=verbose))
    data = summary.to_json()
    return Document(title=run_title(summary), data=data, blocks=[*verdict(summary), *blocks, *where])


def _details(summary: RunSummary) -> list[Block]:
    """Return everything that the summary of one loop has: numbers, timing, conformance, claims."""
    (loop,), tables = summary.loops, {table.name: table for table in summary_tables(summary)}
    blocks: list[Block] = [tables["numbers"]]
    if "timing" in tables:
        blocks += [tables["timing"], *_realtime(loop.realtime)]
    blocks += [Sentence(text=conformance_text(part), is_prose=True) for part in loop.conformance]
    if "claims" in tables:
        blocks += [tables["claims"], *_notes_on_claims(loop)]
    return [*blocks, *([tables["schedule"]] if "schedule" in tables else [])]


def _loops(summary: RunSummary, *, verbose: bool) -> list[Block]:
    """Return the network and the loops; without ``verbose`` the worst only."""
    loops, title = summary.loops, f"{len(summary.loops)} loops"
    if not verbose and len(loops) > _MOST_LOOPS:
        loops = sorted(loops, key=badness, reverse=True)[:_MOST_LOOPS]
        title += ", the worst first"
    more = len(summary.loops) - len(loops)
    more_text = f"and {counted(more, 'more loop')}: --verbose shows all"
    return [
        *(Sentence(text=line) for line in _ended_lines(summary.loops)),
        ResultTable("network", f"network of {run_title(summary)}", KEY_VALUE, network_rows(summary)),
        loops_table(loops, title)._replace(is_dense=True),
        Sentence(text=LOOPS_CAPTION, role=SentenceRole.NOTE),
        *([Sentence(text=more_text)] if more else []),
    ]


def _ended_lines(loops: Sequence[LoopSummary]) -> list[str]:
    """Return why claims ended or were not checked, and in which loops; nothing if that is in the verdict.

    Reasons that differ only in numbers are one.
    """
    reasons = defaultdict[str, list[tuple[str, str]]](list)
    for loop in loops:
        verdicts = (ClaimVerdict.ENDED, ClaimVerdict.UNCHECKED)
        ended = [claim for claim in loop.claims if claim.verdict in verdicts]
        for why in sorted({claim_reason(claim, loop.conformance) for claim in ended}):
            reasons[_NUMBER.sub("#", why)].append((why, loop.name))
    if len(reasons) == 1:
        return []
    lines = list[str]()
    for alike in sorted(reasons.values(), key=lambda alike: -len({name for _, name in alike})):
        names = [*dict.fromkeys(name for _, name in alike)]
        where = names[0] if len(names) == 1 else f"{len(names)} loops"
        lines.append(f"claims ended or unchecked: {_with_ranges([why for why, _ in alike])} ({where})")
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


def _notes_on_claims(loop: LoopSummary) -> Iterator[Sentence]:
    """Yield what the words of the table of claims mean, and why claims did not hold."""
    claims = loop.claims
    if any(claim.ratio is not None for claim in claims):
        yield Sentence(
            role=SentenceRole.NOTE,
            text="share used: largest share of the bound reached during the run; a bound "
            "computed from the run itself is reached by construction. ε: the trigger's floor; t_k: "
            "the k-th event; H = Â + B̂K, or 0 with a hold; W: "
            "trigger.weight. Sources: (I1) and "
            "certificates, docs/theory.md; eq:... and theorems, the paper",
        )
    sources: dict[tuple[str, str], list[str]] = {}
    for claim in claims:
        if reason := claim_reason(claim, loop.conformance):
            sources.setdefault((claim.verdict, reason), []).append(claim.origin)
    for (word, reason), claim_sources in sources.items():
        text = f"{word}: {'; '.join(dict.fromkeys(claim_sources))}: {reason}"
        yield Sentence(text=text, is_prose=True)


def _realtime(realtime: dict[str, dict[str, str]]) -> Iterator[Sentence]:
    """Yield one line for all processes with the same real-time settings."""
    roles_by_settings: dict[str, list[str]] = {}
    for role in sorted(realtime):
        verdicts = realtime[role]
        text = ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items())
        if set(verdicts.values()) == {"applied"}:
            text = "all applied"
        roles_by_settings.setdefault(text, []).append(role)
    for text, roles in roles_by_settings.items():
        whose = "" if len(roles) == len(realtime) else f" of {', '.join(roles)}"
        yield Sentence(text=f"real-time settings{whose}: {text}", is_prose=True)


def assumption_table(assumptions: Sequence[Assumption]) -> ResultTable:
    """Return assumptions with their verdicts."""
    rows = []
    for assumption in assumptions:
        source = assumption.source if assumption.source.startswith("(") else f"({assumption.source})"
        rows.append((str(assumption.verdict), f"{assumption.what} {source}: {assumption.why}"))
    return ResultTable("", "", (), rows, tones=_ASSUMPTION_TONES)


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
