"""What a statement's bounds by forms and those by gains prove, each verified by its own program."""

from collections.abc import Mapping

from flint import arb, fmpq

from noack.proof.gains_document import gains_files
from noack.proof.loop_document import Naming, NoDocumentError
from noack_check.check import RejectedError
from noack_check.loop import Loop
from noack_check.proof import Bound, Proof, prove
from noack_check.sentences import size, smallest_bounds
from noack_gains import RejectedError as RejectedGainsError

_MUCH = 1.03
"""Gains are of use if some figure is smaller with them, or a time larger, by more than this factor."""


def prove_statement(loop: Loop, document: Mapping[str, object]) -> Proof:
    """Return what a document of a search proves of a loop, by forms, by gains, or by both.

    Raises:
        RejectedError: the first inequality that fails, or what is wrong with the document.
    """
    if not isinstance(document, Mapping):
        raise RejectedError("not a table")
    forms = {key: value for key, value in document.items() if key != "gains"}
    if "gains" not in document:
        return prove(loop, forms)
    if "bounds" not in document:
        return prove_by_gains(loop, document)
    return joined(prove(loop, forms), prove_by_gains(loop, document))


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
        Bound(searched[bound.output], arb(bound.levels[0]), arb(bound.levels[1]), True)
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
