"""What a proof proves of a document: its bounds, one after the other, and rule R7 (limits of a region)."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flint import arb, fmpq

from noack_kernel.document import Document, entries, fields, read_table
from noack_kernel.exact import RejectedError
from noack_kernel.forms import Forms

FORMAT = "noack-forms 1"
_DIGITS = 6


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
    def decaying(self) -> float:
        """D1, rounded up."""
        return rounded_up(self.levels[0])

    @property
    def constant(self) -> float:
        """D2, rounded up."""
        return rounded_up(self.levels[1])

    @property
    def largest(self) -> float:
        """(D1² + D2²)^½, rounded up: a bound at all times."""
        return rounded_up(self.levels[0] + self.levels[1])

    def __str__(self) -> str:
        parts = []
        if self.levels[0] > 0:
            rate = float(arb(self.rate).mid())
            parts.append(f"{self.decaying:.{_DIGITS}g}" + (f" e^(−{rate:.{_DIGITS}g} t)" if rate else ""))
        if self.levels[1] > 0 or not parts:
            parts.append(f"{self.constant:.{_DIGITS}g}")
        unit = f" {self.unit}" if self.unit else ""
        when = "at all times" if self.from_start else "in the limit t → ∞"
        where = "" if self.locations is None else f", in the locations {', '.join(map(repr, self.locations))}"
        return f"|{self.output}| ≤ {' + '.join(parts)}{unit} {when}{where}"


def prove(document: str, proof: str) -> list[Statement]:
    """Return what a proof proves of a document; both are the contents of files.

    Raises:
        RejectedError: a file is malformed, or an inequality is not proven: then nothing is proven.
    """
    loop = Document(document)
    table = read_table(proof, FORMAT)
    fields(table, "proof", {"format", "bounds"}, {"document"})
    if "document" in table and table["document"] != loop.digest:
        raise RejectedError("the proof is one of another document, by its digest")
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


def rounded_up(squared: fmpq) -> float:
    """Return a root of a number ≥ 0 with six digits, not below it."""
    root = arb(squared).sqrt().upper()
    shown = float(f"{float(root):.{_DIGITS - 1}e}")
    step = 10.0 ** (1 - _DIGITS)
    while not arb(shown) >= root:
        shown = float(f"{shown * (1 + step):.{_DIGITS - 1}e}")
    return shown


def lines_of_kernel() -> int:
    """Return the number of lines of the kernel, as its files have them."""
    folder = Path(__file__).parent
    return sum(len(re.findall(r"\n", path.read_text())) for path in sorted(folder.glob("*.py")))
