"""What a proof proves of a document: bounds, times, growth, and rule R7 (limits of a region)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from pathlib import Path
from typing import NamedTuple

from flint import arb, fmpq

from noack_kernel.document import Document, Table, entries, fields, read_table
from noack_kernel.event_times import EventTimes, ResetRows
from noack_kernel.exact import RejectedError
from noack_kernel.forms import Forms
from noack_kernel.growth import Growth
from noack_kernel.row_bounds import RowBound, RowBounds

FORMAT = "noack-forms 1"
_DIGITS = 6
_PLAIN_NAME = re.compile(r"[\w' ()-]+")
_PLAIN_UNIT = re.compile(r"(1/)?[^\W\d][^\s|≤,;]{,19}|[%°][^\s|≤,;]{,9}|")
"""Names and units that cannot be taken for a part of a sentence; others are quoted."""


@dataclass(frozen=True)
class Statement:
    """|output| ≤ (D1² e^{−2rt} + D2²)^½, at all times or in the limit t → ∞."""

    output: str
    unit: str
    levels: tuple[fmpq, fmpq]
    """D1² and D2²."""
    rate: fmpq
    """r, 1/s."""
    from_start: bool
    locations: tuple[str, ...] | None
    """Where the bound holds; None: in all locations."""
    inequalities: int
    """So many were verified."""
    during_edges: bool = True
    """Whether it holds while edges last, too. True if none lasts."""
    only: tuple[str, ...] | None = None
    """It holds for runs that visit only these locations; None: for all runs."""

    @property
    def decaying(self) -> Decimal:
        """D1, rounded up."""
        return root_above(self.levels[0])

    @property
    def constant(self) -> Decimal:
        """D2, rounded up."""
        return root_above(self.levels[1])

    @property
    def largest(self) -> Decimal:
        """(D1² + D2²)^½, rounded up: a bound at all times."""
        return root_above(self.levels[0] + self.levels[1])

    def __str__(self) -> str:
        parts = []
        if self.levels[0] > 0:
            decay = f" e^(−{_rounded(self.rate, ROUND_FLOOR):g} t)" if self.rate > 0 else ""
            parts.append(f"{self.decaying:g}{decay}")
        if self.levels[1] > 0 or not parts:
            parts.append(f"{self.constant:g}")
        name = self.output if _PLAIN_NAME.fullmatch(self.output) else repr(self.output)
        unit = self.unit if _PLAIN_UNIT.fullmatch(self.unit) else repr(self.unit)
        unit = f" {unit}" if unit else ""
        when = "at all times" if self.during_edges else "before and after each edge"
        if not self.from_start:
            when = "in the limit t → ∞" if self.during_edges else f"{when}, in the limit t → ∞"
        where = "" if self.locations is None else f", in the locations {', '.join(map(repr, self.locations))}"
        return f"|{name}| ≤ {' + '.join(parts)}{unit} {when}{where}{_visiting(self.only)}"


@dataclass(frozen=True)
class GrowthStatement:
    """The difference of two runs grows at most, or at least, by a factor over a period, in the long run."""

    factor: fmpq
    period: fmpq
    """In s."""
    is_upper: bool
    """No run grows faster; else ``cycle``, repeated, grows at least so fast, from some state on."""
    cycle: tuple[str, ...]
    """Edges."""
    only: tuple[str, ...] | None
    inequalities: int

    def __str__(self) -> str:
        rounding = ROUND_CEILING if self.is_upper else ROUND_FLOOR
        by = f"the factor {_rounded(self.factor, rounding):f} per {_rounded(self.period, ROUND_CEILING):g} s"
        if self.is_upper:
            verdict = "stable" if self.factor < 1 else "not proven stable"
            return (
                f"the difference of two runs with the same loads grows at most by {by} in the long run"
                f"{_visiting(self.only)}: {verdict}"
            )
        verdict = "unstable" if self.factor > 1 else "not proven unstable"
        edges = ", ".join(map(repr, self.cycle))
        return (
            f"the difference of two runs with the same loads grows at least by {by}, "
            f"if these edges repeat: {edges}: {verdict}"
        )


def _visiting(only: tuple[str, ...] | None) -> str:
    return "" if only is None else f", for runs that visit only {', '.join(map(repr, only))}"


@dataclass(frozen=True)
class LeastTime:
    """Two events are at least ``apart`` s apart."""

    apart: fmpq
    outside: tuple[str, ...]
    """Locations in which the loop may be at first, where nothing is proven."""

    def __str__(self) -> str:
        after = ", the start counted as one"
        if self.outside:
            after = f", once the loop has left {', '.join(map(repr, self.outside))}"
        return f"two events are at least {_rounded(self.apart, ROUND_FLOOR):g} s apart{after}"


class Proven(NamedTuple):
    """What a proof proves of a document."""

    bounds: list[Statement]
    least_times: list[LeastTime]
    never: tuple[str, ...]
    """Edges with ``to: null``; all of them are proven to be never taken."""
    growth: list[GrowthStatement]
    inequalities: int
    """So many were verified."""

    @property
    def sentences(self) -> list[str]:
        """The statements, a sentence each."""
        edges = [f"the edge {name!r} is never taken" for name in self.never]
        return [*map(str, self.bounds), *map(str, self.least_times), *edges, *map(str, self.growth)]


def prove(document: str, proof: str) -> Proven:
    """Return what a proof proves of a document; both are the contents of files.

    Raises:
        RejectedError: a file is malformed, or an inequality is not proven: then nothing is proven.
    """
    loop = Document(document)
    table = read_table(proof, FORMAT, "proof")
    fields(table, "proof", {"format", "bounds"}, {"document", "lemmas", "rows", "times", "growth"})
    if "document" in table and table["document"] != loop.digest:
        raise RejectedError("the proof is one of another document: it names another SHA-256")
    lemmas, bounds = _read_forms(loop, table)
    usable = {forms.name: forms for forms in (*lemmas, *bounds) if forms.starts and forms.is_of_all_runs}
    rows = RowBounds(loop, [RowBound(loop, entry) for entry in entries(table.get("rows", []), "rows")])
    count = sum(forms.verify(usable, rows) for forms in lemmas)
    found = [_statement(loop, forms, usable, rows) for forms in bounds]
    levels = {name: forms.levels for name, forms in usable.items() if forms.output is not None}
    count += rows.verify(levels, usable)
    times = [ResetRows(loop, entry, levels).verify() for entry in entries(table.get("times", []), "times")]
    growth = [_growth(loop, Growth(loop, entry)) for entry in entries(table.get("growth", []), "growth")]
    if not found and not growth:
        raise RejectedError("the proof has no bound")
    never = _require_dead(loop, [forms for forms in (*lemmas, *bounds) if forms.is_of_all_runs], times)
    _require_limits(loop, found)
    least = [
        LeastTime(each.apart, tuple(name for name in loop.locations if name not in each.inside))
        for each in times
        if each.apart is not None
    ]
    for statements in (found, growth, times):
        count += sum(each.inequalities for each in statements)
    return Proven(found, least, never, growth, count)


def _read_forms(loop: Document, table: Table) -> tuple[list[Forms], list[Forms]]:
    """Return lemmas and bounds; no two have the same name and kind."""
    lemmas = [Forms(loop, entry) for entry in entries(table.get("lemmas", []), "lemmas")]
    bounds = [Forms(loop, entry) for entry in entries(table["bounds"], "bounds")]
    if any(forms.output is None for forms in bounds) or any(forms.output is not None for forms in lemmas):
        raise RejectedError("a lemma is among the bounds, or a bound among the lemmas")
    kinds = {(forms.name, forms.starts, tuple(forms.locations)) for forms in (*lemmas, *bounds)}
    if len(kinds) < len(lemmas) + len(bounds):
        raise RejectedError("two bounds or lemmas of one name and kind")
    return lemmas, bounds


def _statement(loop: Document, forms: Forms, usable: Mapping[str, Forms], rows: RowBounds) -> Statement:
    output, visited = forms.output, {*forms.locations}
    assert output is not None
    where = tuple(name for name in output.locations if name in visited)
    if not where:
        raise RejectedError(f"{forms.name}: it is in none of the locations that the bound is for")
    during = output.during_edges or not any(edge.duration > 0 for edge in forms.edges)
    return Statement(
        output.name,
        output.unit,
        forms.levels,
        loop.rate,
        forms.starts,
        None if {*where} == visited else where,
        forms.verify(usable, rows),
        during,
        None if visited == {*loop.locations} else tuple(forms.locations),
    )


def _growth(loop: Document, growth: Growth) -> GrowthStatement:
    count = growth.verify()
    only = None if {*growth.locations} == {*loop.locations} else tuple(growth.locations)
    return GrowthStatement(growth.factor, growth.period, growth.is_upper, growth.cycle, only, count)


def _require_dead(loop: Document, forms: Sequence[Forms], times: Sequence[EventTimes]) -> tuple[str, ...]:
    """Require that each edge that leads nowhere is proven to be never taken, by R5 or R10; return them.

    Up to the first time at which one of them is taken all forms are ≤ 0 and all bounds hold, also at this
    time, before the edge: so it is not taken.
    """
    proven = {name for each in forms for name in each.never} | {name for each in times for name in each.never}
    dead = tuple(edge.name for edge in loop.edges if edge.target is None)
    if missing := [name for name in dead if name not in proven]:
        raise RejectedError(f"{missing[0]} leads nowhere, and is not proven to be never taken")
    return dead


def _require_limits(loop: Document, found: list[Statement]) -> None:
    """R7: each limit |y| < less has a bound below it, from the start on and in all locations.

    The document describes the loop until a limit is reached, with the moment itself. Up to then all bounds
    hold. An edge at this moment leaves V ≤ 0 by R2, which uses no motion; so |y| is below the limit after
    it by R4, and a moment later, since y is continuous between edges. So no limit is ever reached.
    """
    for limit in loop.limits:
        levels = [s.levels for s in found if s.output == limit.output and s.from_start and s.only is None]
        if not any(sum(pair, fmpq(0)) < limit.less * limit.less for pair in levels):
            raise RejectedError(
                f"while {limit.output}: no proven bound is below {float(arb(limit.less).mid()):g}"
            )


def root_above(squared: fmpq) -> Decimal:
    """Return a root of a number ≥ 0 with six digits, not below it."""
    return _rounded(arb(squared).sqrt().upper().fmpq(), ROUND_CEILING)


def _rounded(value: fmpq, rounding: str) -> Decimal:
    return Context(prec=_DIGITS, rounding=rounding).divide(Decimal(int(value.p)), Decimal(int(value.q)))


def lines_of_kernel() -> int:
    """Return the number of lines of the kernel, as its files have them."""
    folder = Path(__file__).parent
    return sum(len(re.findall(r"\n", path.read_text())) for path in sorted(folder.glob("*.py")))
