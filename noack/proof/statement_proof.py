"""What a statement's bounds by forms and those by gains prove, each verified by its own program."""

from collections.abc import Mapping

from flint import arb, fmpq

from noack.core.balls import identity, rows_of
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.norms import spectral_norm
from noack.proof.elaborate.tables import read_number
from noack.proof.files import proof_files
from noack.proof.gains_document import gains_files
from noack.proof.loop_document import Naming, NoDocumentError
from noack.proof.search.results import (
    Assumptions,
    FoundBound,
    Proof,
    at_tests,
    last_test_before,
    read_assumptions,
    read_entry,
    size,
    smallest_bounds,
)
from noack_gains import RejectedError as RejectedGainsError
from noack_kernel import Proven
from noack_kernel import RejectedError as RejectedByKernelError

_MUCH = 1.03
"""Gains are of use if some figure is smaller with them, or a time larger, by more than this factor."""


def prove_statement(loop: Loop, document: Mapping[str, object]) -> Proof:
    """Return what a document of a search proves of a loop, by forms, by gains, or by both.

    Raises:
        RejectedError: the first inequality that fails, or what is wrong with the document.
    """
    if not isinstance(document, Mapping):
        raise RejectedError("not a table")
    if "gains" not in document:
        return prove_by_forms(loop, document)
    if "bounds" not in document:
        return prove_by_gains(loop, document)
    return joined(prove_by_forms(loop, document), prove_by_gains(loop, document))


def prove_by_forms(loop: Loop, document: Mapping[str, object]) -> Proof:
    """Return what the bounds of a document prove: those that the kernel proves of the loop document.

    Raises:
        RejectedError: they are not proven, or no loop document describes the loop.
    """
    rate = read_number(document, "rate")
    assumed = read_assumptions(loop, rate, document)
    entries = document.get("bounds")
    if (
        not isinstance(entries, list)
        or not all(isinstance(entry, Mapping) for entry in entries)
        or not entries
    ):
        raise RejectedError("bounds: not a list of tables")
    found = [read_entry(loop, entry, assumed) for entry in entries]
    if len({(each.output, each.from_start) for each in found}) < len(found):
        raise RejectedError("bounds: an output occurs twice")
    try:
        files = proof_files(loop, document, Naming("loop"))
        proven = files.verify()
    except NoDocumentError as error:
        raise RejectedError(str(error)) from None
    except RejectedByKernelError as error:
        raise RejectedError(f"the kernel rejects the proof: {error}") from None
    searched = {label: name for name, label in files.output_names.items()}
    bounds = []
    for each in proven.bounds:
        decaying, constant = (arb(level).sqrt() for level in each.levels)
        bound = FoundBound(searched[each.output], decaying, constant, each.from_start)
        if not bound.decaying.is_finite() or not bound.constant.is_finite():
            raise RejectedError("bounds: not finite")
        bounds.append(_about(loop, _joined(bound) if rate == 0 else bound))
    apart, first, is_quiet = _times(loop, assumed, proven)
    return Proof(rate, tuple(bounds), apart, first, is_quiet)


def _times(loop: Loop, assumed: Assumptions, proven: Proven) -> tuple[fmpq | None, fmpq | None, bool]:
    """Return least times between events, and of the first event after t = 0, and whether the start is quiet.

    What the kernel has proven is a time in which none happens; events come at tests.
    """
    times = loop.times
    apart = max((each.apart for each in proven.least_times), default=None)
    is_quiet = assumed.later_at_start == 0
    first: fmpq | None = fmpq(0)
    if times.start == 0:  # the event at t = 0 counts as others do
        first = apart
    elif is_quiet:
        first = last_test_before(times, times.start) if times.sampling > 0 else times.start
    return at_tests(times, apart), at_tests(times, first), is_quiet


def _joined(bound: FoundBound) -> FoundBound:
    """Return a bound by forms whose units do not decay: f₁ = f₂ = 1, and |Cz|² ≤ D₁² + D₂²."""
    return bound._replace(decaying=arb(0), constant=(bound.decaying**2 + bound.constant**2).sqrt())


def _about(loop: Loop, bound: FoundBound) -> FoundBound:
    """Return the bound of an output itself, x being at most ``loop.offset`` from where the loop has it."""
    output, n = bound.output, loop.n
    if loop.offset == 0 or output[0] not in "xy":
        return bound
    row = identity(n) if output == "x" else loop.output_rows if output[0] == "y" else identity(n)
    if "[" in output:
        row = rows_of(row, [int(output[2:-1])])
    return bound._replace(constant=bound.constant + loop.offset * spectral_norm(row))


def prove_by_gains(loop: Loop, document: Mapping[str, object]) -> Proof:
    """Return what the table "gains" of a document proves.

    On a region it may hold only until a limit is reached: :func:`joined` needs forms then.

    Raises:
        RejectedError: it is not proven.
    """
    if fault := loop.fault():
        raise RejectedError(f"loop: {fault}")
    try:
        files = gains_files(loop, document, Naming("loop"))
        proven = files.verify()
    except (RejectedGainsError, NoDocumentError) as error:
        raise RejectedError(f"gains: {error}") from None
    if proven.open_limits and "bounds" not in document:
        raise RejectedError(f"region: {proven.open_limits[0]} may be reached")
    searched = {label: name for name, label in files.output_names.items()}
    bounds = [
        FoundBound(searched[bound.output], arb(bound.levels[0]), arb(bound.levels[1]), True)
        for bound in proven.bounds
    ]
    rate = arb(proven.bounds[0].rate)
    if loop.needs_constant and rate > 0 and loop.until is None:  # then what the start adds is in f₁
        bounds += [
            bound._replace(decaying=arb(0), from_start=False) for bound in bounds if bound.output[0] in "xy"
        ]
    apart = proven.inter_event if proven.inter_event > 0 else None
    is_quiet = loop.times.start == 0 or (apart is not None and apart >= loop.times.start)
    return Proof(rate, tuple(bounds), apart, apart, is_quiet)


def joined(by_forms: Proof, by_gains: Proof) -> Proof:
    """Return what two proofs of a loop with one rate prove together."""
    apart, first = (
        _later(getattr(by_forms, name), getattr(by_gains, name)) for name in ("inter_event", "first_event")
    )
    is_quiet = by_forms.is_quiet or by_gains.is_quiet
    return Proof(by_forms.rate, (*by_forms.bounds, *by_gains.bounds), apart, first, is_quiet)


def needs_gains(by_forms: Proof, both: Proof) -> bool:
    """Return whether some figure that is printed is clearly better with gains than without."""
    less = {(b.output, b.from_start): size(b) for b in smallest_bounds(by_forms)}
    if any(less.get((b.output, b.from_start), size(b) * 2) > _MUCH * size(b) for b in smallest_bounds(both)):
        return True
    pairs = (
        (by_forms.inter_event, both.inter_event),
        (by_forms.first_event, both.first_event),
    )
    return any(after is not None and after > (before or 0) * fmpq(103, 100) for before, after in pairs)


def _later(time: fmpq | None, other: fmpq | None) -> fmpq | None:
    known = [each for each in (time, other) if each is not None]
    return max(known) if known else None
