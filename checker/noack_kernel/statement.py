"""What a proof proves of a document: its bounds, one after the other, and rule R7 (limits of a region)."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from pathlib import Path

from flint import arb, fmpq

from noack_kernel.document import Document, entries, fields, read_table
from noack_kernel.exact import RejectedError
from noack_kernel.forms import Forms

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
        when = "at all times" if self.from_start else "in the limit t → ∞"
        where = "" if self.locations is None else f", in the locations {', '.join(map(repr, self.locations))}"
        return f"|{name}| ≤ {' + '.join(parts)}{unit} {when}{where}"


def prove(document: str, proof: str) -> list[Statement]:
    """Return what a proof proves of a document; both are the contents of files.

    Raises:
        RejectedError: a file is malformed, or an inequality is not proven: then nothing is proven.
    """
    loop = Document(document)
    table = read_table(proof, FORMAT)
    fields(table, "proof", {"format", "bounds"}, {"document"})
    if "document" in table and table["document"] != loop.digest:
        raise RejectedError("the proof is one of another document: it names another SHA-256")
    found = [_statement(loop, forms) for forms in _in_order(loop, table["bounds"])]
    if not found:
        raise RejectedError("the proof has no bound")
    _require_limits(loop, found)
    return found


def _in_order(loop: Document, value: object) -> Iterator[Forms]:
    """Yield the entries of a proof, one at a time, so that one is read when the one before is verified."""
    seen = set()
    for entry in entries(value, "bounds"):
        forms = Forms(loop, entry)
        if (forms.name, forms.starts) in seen:
            raise RejectedError(f"{forms.name}: two bounds of one kind")
        seen.add((forms.name, forms.starts))
        yield forms


def _statement(loop: Document, forms: Forms) -> Statement:
    output = forms.output
    everywhere = {*output.locations} == {*loop.locations}
    locations = None if everywhere else output.locations
    count = forms.verify()
    return Statement(output.name, output.unit, forms.levels, loop.rate, forms.starts, locations, count)


def _require_limits(loop: Document, found: list[Statement]) -> None:
    """R7: each limit |y| < less has a bound below it, from the start on and in all locations.

    The document describes the loop until a limit is reached, with the moment itself. Up to then all bounds
    hold. An edge at this moment leaves V ≤ 0 by R2, which uses no motion; so |y| is below the limit after
    it by R4, and a moment later, since y is continuous between edges. So no limit is ever reached.
    """
    for limit in loop.limits:
        levels = [s.levels for s in found if s.output == limit.output and s.from_start]
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
