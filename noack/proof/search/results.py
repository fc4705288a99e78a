"""What a search finds of a loop, and what is proven of it: bounds over time, and times between events.

A document of a search names a rate r, what the model assumes, and for each output a decay, matrices and
numbers. :func:`check_bound` tests them with the model's inequalities, exactly: so a search knows which of its
solutions are worth a proof. The proof itself is written by :mod:`noack.proof`, and verified by the kernel.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from flint import arb, arb_mat, fmpq

from noack.core.balls import identity, is_zero
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Errors, Model
from noack.proof.elaborate.loop import Loop, Noise, Smooth, Times
from noack.proof.elaborate.noise import noise_of
from noack.proof.elaborate.tables import read_count, read_matrix, read_number, read_rows, read_table
from noack.proof.elaborate.tests_apart import MOST_PLACES
from noack.proof.search.exact_test import verify

MOST_PIECES = 64
_MOST_COORDINATES = 200
MOST_LATER = 8
"""Most events within the time that an update may be on its way."""


class FoundBound(NamedTuple):
    """|output| ≤ D₁ e^{−rt} + D₂, for all t ≥ 0, or only in the limit t → ∞.

    A bound by quadratic forms, as that of the drift, is even (D₁² e^{−2rt} + D₂²)^½.
    """

    output: str
    decaying: arb  # D₁
    constant: arb  # D₂
    from_start: bool


class Proof(NamedTuple):
    """What was proven of a loop."""

    rate: arb  # r, 1/s
    bounds: tuple[FoundBound, ...]
    inter_event: fmpq | None
    """Two events after the one at t = 0 are at least this far apart, s; None: nothing is known."""
    first_event: fmpq | None
    """No event follows the one at t = 0 before this time, s."""
    is_quiet: bool
    """No event follows the one at t = 0 before the first input acts; else the other times hold from it on."""


class Assumptions(NamedTuple):
    """What the model assumes."""

    errors: Errors | None
    later: int
    later_at_start: int
    pieces: int = 1
    """Parts of the period of a periodic rule: the nodes of its clock."""
    noise: Noise | None = None
    """Of an observer."""
    by_tests: bool = False
    """V depends on where each update is at each test."""
    counted: int = 0
    """It depends on the number of silent tests since the last event, too, up to so many."""
    blocks: bool = False
    """It has no products of an update on its way with other states."""

    @property
    def of_model(self) -> dict[str, Any]:
        """Further arguments of the model."""
        names = ("later", "later_at_start", "pieces", "by_tests", "counted", "blocks")
        return {name: getattr(self, name) for name in names}


def read_assumptions(loop: Loop, rate: arb, document: Mapping[str, object]) -> Assumptions:
    """Return what a document with a rate r assumes of a loop.

    Raises:
        RejectedError: loop, rate or document have no meaning.
    """
    if fault := loop.fault():
        raise RejectedError(f"loop: {fault}")
    try:
        loop.weight.inv()
    except ZeroDivisionError:
        raise RejectedError("weight: not proven to have an inverse") from None
    if not rate >= 0 or not (loop.rule.level == 0 or rate <= loop.rule.rate):
        raise RejectedError("rate: not between 0 and that of the threshold")
    later, at_start = (read_count(document, key, MOST_LATER) for key in ("later", "later_at_start"))
    pieces = read_count(document, "pieces", MOST_PIECES) if "pieces" in document else 1
    if pieces < 1:
        raise RejectedError("pieces: below 1")
    smooth = _read_smooth(loop, document) if "observer" in document else None
    noise, by_tests = noise_of(loop, rate, smooth), document.get("by_tests", False)
    if by_tests and (loop.times.period > 0 or not loop.times.sampling == loop.times.least_sampling > 0):
        raise RejectedError("by_tests: the tests are not an exact time apart")
    if (by_tests or loop.needs_tests_apart) and loop.loads:
        raise RejectedError("by_tests: not with unknown loads")
    by_tests = bool(by_tests) or loop.needs_tests_apart
    counted = read_count(document, "counted", MOST_PLACES) if "counted" in document else 0
    if counted and not by_tests:
        raise RejectedError("counted: only forms of each test count tests")
    blocks = document.get("blocks", False) is True
    if blocks and (by_tests or loop.times.period > 0):
        raise RejectedError("blocks: not with a periodic rule, or with forms of each test")
    if "errors" not in document:
        return Assumptions(None, later, at_start, pieces, noise, by_tests, counted, blocks)
    if loop.times.period > 0 or by_tests or noise.columns.ncols() or noise.smooth.rates.nrows():
        raise RejectedError("errors: not with a periodic rule, with forms of each test, or with noise")
    table = document["errors"]
    if not isinstance(table, Mapping):
        raise RejectedError("errors: not a table")
    sizes = read_number(table, "decaying"), read_number(table, "constant")
    units = loop.has_decaying_unit(rate), loop.needs_constant
    if not all(size == 0 or (size > 0 and is_unit) for size, is_unit in zip(sizes, units, strict=True)):
        raise RejectedError("errors: below 0, or in a unit that the loop does not have")
    return Assumptions(Errors(*sizes), later, at_start, pieces, noise, blocks=blocks)


def _read_smooth(loop: Loop, document: Mapping[str, object]) -> Smooth:
    """Return the part of the observer's error that decays smoothly; nothing of it has to be right."""
    table = read_table(document, "observer")
    columns, rates, start = (read_rows(table, key) for key in ("columns", "rates", "start"))
    q = rates.nrows()
    shapes = [(M.nrows(), M.ncols()) for M in (columns, rates, start)]
    if shapes != [(loop.n, q), (q, q), (q, 1)]:
        raise RejectedError("observer: columns, rates and start do not fit")
    return Smooth(columns, rates, start)


class Entry(NamedTuple):
    """What a search has found of an output."""

    output: str
    decay: arb
    matrices: Mapping[str, arb_mat]
    numbers: Mapping[str, arb]
    from_start: bool

    @property
    def bound(self) -> FoundBound:
        """The bound that it states."""
        levels = (self.numbers.get(name, arb(0)) for name in ("level 1", "level 2"))
        decaying, constant = (level.sqrt() for level in levels)
        return FoundBound(self.output, decaying, constant, self.from_start)


def read_entry(loop: Loop, entry: Mapping[str, object], assumed: Assumptions) -> Entry:
    """Return an entry of a document's bounds.

    Raises:
        RejectedError: it has no meaning.
    """
    decay = read_number(entry, "decay")
    output, starts = str(entry.get("output")), bool(entry.get("from_start", True))
    if not starts and loop.until is not None:
        raise RejectedError(f"{output[:50]}: no bound in the limit: the loop is known up to a time only")
    counts = {"x": loop.n, "u": loop.B.ncols(), "y": loop.output_rows.nrows()}
    entries = {f"{kind}[{i}]" for kind, count in counts.items() for i in range(count)}
    if output not in {"x", "e_s", "e_c", "drift"} | entries:
        raise RejectedError(f"output: {output[:50]!r} is none of the loop's")
    if output.startswith("u[") and (
        loop.loads > 0 or loop.until is not None or loop.push_before_input is not None
    ):
        raise RejectedError("u: about a reference, or where the loop rests, the input is not an output")
    if output.startswith("e_") and assumed.by_tests and loop.seen is not None:
        raise RejectedError(
            f"{output}: the model has no more of errors than the input and the rule depend on"
        )
    if output == "e_s" and loop.times.period > 0:
        raise RejectedError("e_s: the model of a periodic rule has no error of an update that is lost")
    matrices, numbers = entry.get("matrices"), entry.get("numbers")
    if not isinstance(matrices, Mapping) or not isinstance(numbers, Mapping):
        raise RejectedError(f"{output}: matrices or numbers are missing")
    return Entry(
        output,
        decay,
        {name: read_matrix(matrices, name, most=_MOST_COORDINATES) for name in matrices},
        {name: read_number(numbers, name) for name in numbers},
        starts,
    )


def check_bound(loop: Loop, rate: arb, entry: Mapping[str, object], assumed: Assumptions) -> FoundBound:
    """Return the bound of one output, after testing its inequalities."""
    found = read_entry(loop, entry, assumed)
    try:
        model = Model(loop, rate, found.decay, assumed.errors, assumed.noise, **assumed.of_model)
    except ValueError as error:
        raise RejectedError(str(error)) from None
    try:
        verify(model, found.output, found.matrices, found.numbers, starts=found.from_start)
    except RejectedError as error:
        raise RejectedError(f"{found.output}: {error}") from None
    return found.bound


def weighted(loop: Loop, rate: arb) -> arb_mat:
    """Return W (H + r) W⁻¹."""
    H = loop.weight * loop.H * loop.weight.inv()
    return H if is_zero(H) and rate == 0 else H + rate * identity(loop.n)


def last_test_before(times: Times, until: fmpq) -> fmpq:
    """Return the time of the last test before a time; one at this time comes after it."""
    if times.least_sampling == 0:
        return until
    tests = (until / times.least_sampling).ceil() - 1
    return min(tests * times.sampling, until)


def silent_tests(times: Times, apart: fmpq) -> int:
    """Return how many tests after an event come within a time in which none is an event."""
    return int((apart / times.sampling).floor()) if times.sampling > 0 else 0


def at_tests(times: Times, apart: fmpq | None) -> fmpq | None:
    """Return how far events are apart at least, if none comes within a time after another: it is a test's.

    None: nothing is known.
    """
    if not times.least_apart > 0:
        return apart
    apart = apart or fmpq(0)
    return max(apart, times.least_apart, (silent_tests(times, apart) + 1) * times.least_sampling)


def compares_error(loop: Loop) -> bool:
    """Return whether the rule compares ‖W e_s‖ with a threshold at all tests."""
    return _exceeds_by_error(loop) and not loop.rule.negative.nrows() and not loop.needs_tests_apart


def _exceeds_by_error(loop: Loop) -> bool:
    """Return whether the rule compares ‖W e_s‖ with at least its threshold."""
    n, positive = loop.n, loop.rule.positive
    if positive.nrows() != n or loop.rule.of_input or loop.rule.integrates:
        return False
    entries = (
        (positive[i, j], loop.weight[i, j - n] if j >= n else 0) for i in range(n) for j in range(2 * n)
    )
    return all(entry == expected for entry, expected in entries)


def smallest_bounds(proof: Proof) -> list[FoundBound]:
    """Return the bounds of a proof; of two bounds of the same output the smaller one.

    Left out is a limit that is not below what the bound from the start on tends to.
    """
    smallest: dict[tuple[str, bool], FoundBound] = {}
    for bound in proof.bounds:
        key = (bound.output, bound.from_start)
        if key not in smallest or size(bound) < size(smallest[key]):
            smallest[key] = bound
    return [
        bound
        for (output, from_start), bound in smallest.items()
        if from_start or not _limit_is_implied(bound, smallest.get((output, True)), proof.rate)
    ]


def _limit_is_implied(limit: FoundBound, bound: FoundBound | None, rate: arb) -> bool:
    return bound is not None and bool(rate > 0 and bound.constant <= limit.constant)


def size(bound: FoundBound) -> float:
    """Return the bound at t = 0, as it is printed, or what is left of one in the limit."""
    if not bound.from_start:
        return float(bound.constant.mid())
    return float((bound.decaying + bound.constant).mid())
