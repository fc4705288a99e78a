"""The two files of a proven statement: its loop document, and the proof of the document's bounds."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.tables import read_number
from noack.proof.equations_claim import add_claim
from noack.proof.forms_proof import as_text, write_proof
from noack.proof.loop_document import LoopDocument, Naming, NoDocumentError
from noack.proof.search.results import compares_error, read_assumptions
from noack.proof.words import in_words
from noack_kernel import Proven, prove


class ProofFiles(NamedTuple):
    """A loop document and a proof of its bounds."""

    table: Mapping[str, Any]
    """The document."""
    document: str
    proof: str
    """The contents of the files."""
    output_names: Mapping[str, str]
    """The document's names of the outputs, by those of the search."""

    @property
    def words(self) -> str:
        """The document as text."""
        return in_words(self.table)

    def verify(self) -> Proven:
        """Return what the kernel proves; raise its RejectedError if it rejects the proof."""
        return prove(self.document, self.proof)


def proof_files(loop: Loop, statement: Mapping[str, object], naming: Naming) -> ProofFiles:
    """Return the files of a statement about a loop, as the search has found it.

    Raises:
        NoDocumentError: it has no bounds by quadratic forms, or no document describes the loop.
    """
    document = document_of(loop, statement, naming)
    document.require_counted()
    proof = write_proof(document, _bounds(statement), apart_of(loop, statement))
    return ProofFiles(document.table, as_text(document.table), as_text(proof), document.output_names)


def document_of(loop: Loop, statement: Mapping[str, object], naming: Naming) -> LoopDocument:
    """Return the loop document of a statement; raise NoDocumentError as :func:`proof_files`."""
    rate = read_number(statement, "rate")
    outputs = [str(bound["output"]) for bound in _bounds(statement)]
    document = LoopDocument(loop, rate, read_assumptions(loop, rate, statement), outputs, naming)
    if "equations" in statement:
        add_claim(document, statement)
    return document


def _bounds(statement: Mapping[str, object]) -> list[Any]:
    bounds = statement.get("bounds")
    if not isinstance(bounds, list) or not bounds:
        raise NoDocumentError(
            "the bounds are small-gain bounds, of a document of another format; noack certify NAME "
            "--document D --proof P writes it"
        )
    return bounds


def apart_of(loop: Loop, statement: Mapping[str, object]) -> float:
    """Return the time that two events are at least apart by the bound of the mismatch, in s; 0: unknown."""
    if "inter_event_s" not in statement or not compares_error(loop) or loop.rule.always:
        return 0.0
    return float(read_number(statement, "inter_event_s"))
