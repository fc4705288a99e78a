"""What a proof proves of a document: bounds of its outputs, and a least time between events."""

import re
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from pathlib import Path
from typing import NamedTuple

from flint import arb, fmpq

from noack_gains.apart import share_of_threshold
from noack_gains.balls import spectral_norm
from noack_gains.document import Document, Output
from noack_gains.gains import Gains
from noack_gains.reading import RejectedError, Table, fields, read_table, size

FORMAT = "noack-gains 1"
_OPTIONAL = ("by_time", "tests", "window_s", "comparison", "model", "inter_event_s")
_DIGITS, _SQUARINGS = 6, 14
_PLAIN_NAME = re.compile(r"[\w' ()-]+")
_PLAIN_UNIT = re.compile(r"(1/)?[^\W\d][^\s|≤,;]{,19}|[%°][^\s|≤,;]{,9}|")
"""Names and units that cannot be taken for a part of a sentence; others are quoted."""


class Statement(NamedTuple):
    """|output| ≤ D₁ e^{−rt} + D₂, up to the document's time, or at all times."""

    output: str
    unit: str
    levels: tuple[fmpq, fmpq]
    """D₁ and D₂, rounded up."""
    rate: fmpq
    """r, 1/s."""
    until: fmpq | None

    @property
    def largest(self) -> fmpq:
        """D₁ + D₂, a bound at all times."""
        return self.levels[0] + self.levels[1]

    def __str__(self) -> str:
        parts = []
        if self.levels[0] > 0:
            decay = f" e^(−{rounded(self.rate, ROUND_FLOOR):g} t)" if self.rate > 0 else ""
            parts.append(f"{rounded(self.levels[0], ROUND_CEILING):g}{decay}")
        if self.levels[1] > 0 or not parts:
            parts.append(f"{rounded(self.levels[1], ROUND_CEILING):g}")
        name = _quoted(self.output)
        unit = self.unit if _PLAIN_UNIT.fullmatch(self.unit) else repr(self.unit)
        when = "at all times" if self.until is None else f"up to {rounded(self.until, ROUND_FLOOR):g} s"
        return f"|{name}| ≤ {' + '.join(parts)}{f' {unit}' if unit else ''} {when}"


class Proven(NamedTuple):
    """What was proven of a document."""

    bounds: tuple[Statement, ...]
    inter_event: fmpq
    """Two events are at least this far apart, s; 0: nothing is known."""
    open_limits: tuple[str, ...]
    """Limits of the document that these bounds do not stay below: all holds until one of them is reached."""

    def __str__(self) -> str:
        return "\n".join(self.sentences())

    def sentences(self) -> list[str]:
        """Return each statement in words."""
        found = [str(bound) for bound in self.bounds]
        if self.inter_event > 0:
            found.append(f"two events are at least {rounded(self.inter_event, ROUND_FLOOR):g} s apart")
        if self.open_limits:
            end = f", until {' or '.join(self.open_limits)} is reached"
            found = [f"{sentence}{end}" for sentence in found]
        return found


def prove(document: str, proof: str) -> Proven:
    """Return what a proof proves of a document; both are the contents of files.

    Raises:
        RejectedError: a file is malformed, or an inequality is not proven: then nothing is proven.
    """
    loop = Document(document)
    table = read_proof(loop, proof)
    gains = Gains(loop, table)
    bounds = tuple(_statement(loop, output, gains.bounds[output.name]) for output in loop.outputs)
    return Proven(bounds, _inter_event(gains, table), _open_limits(loop, bounds))


def read_proof(document: Document, proof: str) -> Table:
    """Return the table of a proof of a document."""
    table = read_table(proof, FORMAT, "proof")
    fields(table, "proof", ("format", "plant", "inputs"), ("document", *_OPTIONAL))
    if "document" in table and table["document"] != document.digest:
        raise RejectedError("the proof is one of another document: it names another SHA-256")
    return table


def _statement(loop: Document, output: Output, levels: tuple[arb, arb]) -> Statement:
    """Return the bound of an output itself, x being at most ``offset`` from where the loop has it."""
    decaying, constant = levels
    if output.rows is not None and loop.offset > 0:
        constant = constant + arb(loop.offset) * spectral_norm(output.rows.balls, _SQUARINGS)
    if not (decaying.is_finite() and constant.is_finite()):
        raise RejectedError(f"{output.name}: its bound is not finite")
    found = tuple(arb(level.upper()).fmpq() for level in (decaying, constant))
    return Statement(output.name, output.unit, (found[0], found[1]), loop.rate, loop.until)


def _inter_event(gains: Gains, table: Table) -> fmpq:
    """Return a least time between any two events: the proof's, and up to the next test.

    Events need ‖W (e_s − n)‖ above the threshold; those without it come at ``due`` at the earliest.
    """
    document, times = gains.document, gains.document.times
    apart = size(table.get("inter_event_s", fmpq(0)), "inter_event_s")
    if apart > 0:
        if not document.compares_error or document.rule.integrates:
            raise RejectedError("inter_event_s: not proven for this rule; 0 is")
        if document.rule.always and not apart < times.due:
            raise RejectedError("inter_event_s: an event without a comparison may come earlier")
        if not share_of_threshold(gains, arb(apart)) < 1:
            raise RejectedError("inter_event_s: an event may come earlier")
    silent = (apart / times.sampling).floor() if times.sampling > 0 else fmpq(0)
    if not times.least_apart > 0:
        return apart
    return max(apart, times.least_apart, (silent + 1) * times.least_sampling)


def _open_limits(loop: Document, bounds: tuple[Statement, ...]) -> tuple[str, ...]:
    """Return the limits |y| < less that no bound here is below.

    All bounds hold up to the first time at which a limit is reached, with this time: x is continuous, and
    so is the bound of the input that acts next. So a limit with a bound below it is not the first.
    """
    sizes = {bound.output: bound.largest for bound in bounds}
    return tuple(
        f"|{_quoted(limit.output)}| = {rounded(limit.less, ROUND_FLOOR):g}"
        for limit in loop.limits
        if not sizes[limit.output] < limit.less
    )


def _quoted(name: str) -> str:
    """Return a name, in quotes if it could be taken for a part of the sentence."""
    return name if _PLAIN_NAME.fullmatch(name) else repr(name)


def rounded(value: fmpq, rounding: str) -> Decimal:
    """Return a number with six digits."""
    return Context(prec=_DIGITS, rounding=rounding).divide(Decimal(int(value.p)), Decimal(int(value.q)))


def lines_of_gains() -> int:
    """Return the number of lines of this verifier, as its files have them."""
    folder = Path(__file__).parent
    return sum(len(re.findall(r"\n", path.read_text())) for path in sorted(folder.glob("*.py")))
