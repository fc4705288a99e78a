"""The document of a loop for bounds by gains, and the proof of its bounds, as ``noack_gains`` reads them.

Nothing here is trusted: the verifier of gains reads the files, and knows neither a loop nor a search.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flint import arb, arb_mat

from noack.core.balls import rows_of
from noack.proof.elaborate.errors import RejectedError as NoNoiseBoundError
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.noise import noise_of
from noack.proof.equations_claim import add_claim_of_gains
from noack.proof.forms_proof import as_text
from noack.proof.loop_document import Naming, NoDocumentError, Table
from noack.proof.numbers import exact, least_above, matrix, quotient, to_fraction
from noack_gains import Document, Proven, RejectedError, in_words, prove

LOOP_FORMAT, PROOF_FORMAT = "noack-gains-loop 1", "noack-gains 1"
_ERRORS = {"e_s": "sensor", "e_c": "controller"}


@dataclass(frozen=True)
class GainsFiles:
    """A document of a loop and a proof of its bounds by gains.

    Attributes:
        table: the document.
        output_names: the document's name of each output, which the search calls "y[0]".
        document: the content of the document's file.
        proof: the content of the proof's file.
    """

    table: Mapping[str, Any]
    output_names: Mapping[str, str]
    document: str
    proof: str

    def verify(self) -> Proven:
        """Return what the verifier of gains proves; raise its RejectedError if it rejects the proof."""
        return prove(self.document, self.proof)

    @property
    def words(self) -> str:
        """The document as text."""
        return "\n".join(in_words(Document(self.document)))


def gains_files(loop: Loop, statement: Mapping[str, object], naming: Naming) -> GainsFiles:
    """Return the files of a statement about a loop, as the search has found it.

    Args:
        loop: the loop.
        statement: with its rate r, and the table "gains".
        naming: of the loop.

    Raises:
        NoDocumentError: it has no bounds by gains, or the document has no words for the loop.
    """
    gains, rate = statement.get("gains"), statement["rate"]
    if not isinstance(gains, Mapping) or not isinstance(rate, float | int):
        raise NoDocumentError("there are no bounds by gains")
    outputs = gains.get("outputs")
    if not isinstance(outputs, list):
        raise RejectedError("outputs: not a list")
    table, names = gains_document(loop, rate, outputs, naming)
    if "equations" in statement:
        add_claim_of_gains(table, loop, statement)
    document = as_text(table)
    return GainsFiles(table, names, document, proof_text(document, gains))


def proof_text(document: str, gains: Mapping[str, object]) -> str:
    """Return the content of a proof's file, with the numbers that a search has found."""
    digest = hashlib.sha256(document.encode()).hexdigest()
    numbers = {key: value for key, value in gains.items() if key != "outputs"}
    try:
        return as_text({"format": PROOF_FORMAT, "document": digest, **numbers})
    except ValueError:
        raise RejectedError("a number of the proof is not finite") from None


def gains_document(
    loop: Loop, rate: float, outputs: Sequence[str], naming: Naming
) -> tuple[Table, dict[str, str]]:
    """Return the document's table, and its names of the outputs.

    Args:
        loop: the loop.
        rate: r in f₁ = e^{−rt}, 1/s.
        outputs: those to bound, as the search calls them: "x", "e_c", "y[0]".
        naming: of the loop.

    Raises:
        NoDocumentError: the document has no words for the loop.
    """
    rule, times = loop.rule, loop.times
    if loop.loads or rule.memory is not None or rule.of_input:
        raise NoDocumentError("not with loads, nor a rule with a memory or of the input")
    if not (math.isfinite(rate) and rate >= 0):
        raise RejectedError("rate: not a number of at least 0")
    n, m = loop.n, int(loop.B.ncols())
    try:
        decaying, constant = noise_of(loop, arb(rate)).sizes
    except NoNoiseBoundError as error:
        raise NoDocumentError(str(error)) from None
    if not (decaying.is_finite() and constant.is_finite()):
        raise NoDocumentError("the noise has no bound")
    names = _output_names(loop, outputs, naming)
    halves = {"A": _above(loop.half_A), "B": _above(loop.half_B)}
    model = {"A": matrix(loop.model_A), "B": matrix(loop.model_B)}
    table: Table = {
        "format": LOOP_FORMAT,
        "name": naming.loop,
        "rate": rate,
        "states": [{"name": naming.state(i), "unit": naming.unit(f"x[{i}]")} for i in range(n)],
        "inputs": [str(j) for j in range(m)],
        "A": matrix(loop.A),
        "B": matrix(loop.B),
        "uncertainty": halves if any(map(any, [*halves["A"], *halves["B"]])) else None,
        "model": None if loop.holds else model,
        "gain": matrix(loop.gain),
        "weight": matrix(loop.weight),
        "start": matrix(loop.start),
        "before_input": None if loop.push_before_input is None else matrix(loop.push_before_input),
        "rule": {
            "compared": matrix(rule.positive),
            "share": matrix(rule.negative),
            "level": exact(rule.level),
            "rate": exact(rule.rate),
            "floor": _least(rule.floor),
            "always": rule.always,
            "integrates": rule.integrates,
        },
        "times": {name: exact(getattr(times, name)) for name in times._fields},
        "losses": loop.losses,
        "disturbances": [
            {"column": [[row[k]] for row in matrix(loop.pushes)], "size": least_above(size)}
            for k, size in enumerate(loop.sizes)
        ],
        "noise": {"decaying": least_above(decaying), "constant": least_above(constant)},
        "until": None if loop.until is None else exact(loop.until),
        "offset": least_above(loop.offset),
        "outputs": [_output(loop, name, label, naming) for name, label in names.items()],
    }
    if loop.region is not None and (limits := [*_limits(loop, names)]):
        table["while"] = limits
    return {key: value for key, value in table.items() if value is not None or key == "model"}, names


def _output_names(loop: Loop, outputs: Sequence[str], naming: Naming) -> dict[str, str]:
    counts = {"x": loop.n, "u": int(loop.B.ncols()), "y": int(loop.output_rows.nrows())}
    known = {f"{kind}[{i}]" for kind, count in counts.items() for i in range(count)} | {"x", *_ERRORS}
    if unknown := {*map(str, outputs)} - known:
        raise RejectedError(f"outputs: {min(unknown)[:50]!r} is none of the loop's")
    found: dict[str, str] = {}
    for name in dict.fromkeys(map(str, outputs)):
        label, count = naming.output(name), 1
        while (label if count == 1 else f"{label} ({count})") in found.values():
            count += 1
        found[name] = label if count == 1 else f"{label} ({count})"
    return found


def _output(loop: Loop, name: str, label: str, naming: Naming) -> Table:
    found: Table = {"name": label, "unit": naming.unit(name)}
    if name in _ERRORS:
        return found | {"error": _ERRORS[name]}
    if name.startswith("u["):
        return found | {"input": int(name[2:-1])}
    if name == "x":
        return found | {"rows": [[int(i == j) for j in range(loop.n)] for i in range(loop.n)]}
    index = int(name[2:-1])
    if name.startswith("x["):
        return found | {"rows": [[int(index == j) for j in range(loop.n)]]}
    return found | {"rows": matrix(rows_of(loop.output_rows, [index]))}


def _limits(loop: Loop, names: Mapping[str, str]) -> list[Table]:
    region, found = loop.region, []
    assert region is not None
    for kind, limits in zip("xu", region, strict=True):
        for index, limit in enumerate(limits):
            if limit is None:
                continue
            if f"{kind}[{index}]" not in names:
                raise NoDocumentError(f"the limit of {kind}[{index}] has no bound by gains")
            found.append({"output": names[f"{kind}[{index}]"], "less": quotient(to_fraction(limit.lower()))})
    return found


def _above(M: arb_mat) -> list[list[float]]:
    """Return half-widths, rounded up; those that are exactly 0 stay 0."""
    return [[0 if M[i, j] == 0 else least_above(M[i, j]) for j in range(M.ncols())] for i in range(M.nrows())]


def _least(value: arb) -> Any:
    """Return a number, rounded up if it is a ball, as the root of a decimal."""
    return exact(value) if value.is_exact() else least_above(value)
