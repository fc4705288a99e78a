"""The loop document of a scenario's statement and the proof of its bounds, with the scenario's names."""

from cosim.analysis.witnesses import WitnessedStatement, Witnesses
from netem.core.errors import CallerError
from noack.proof.elaborate.loop import Loop
from noack.proof.files import ProofFiles, proof_files
from noack.proof.gains_document import GainsFiles, gains_files
from noack.proof.loop_document import Naming, NoDocumentError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario

_PLANTS = {"own": "the plant", "box": "all plants of its uncertainty", "region": "the plant's equations"}
_CONDITIONS = {"schedule": "its schedule", "ideal": "ideal conditions"}


def loop_files(resolved: Scenario, statement: WitnessedStatement) -> ProofFiles:
    """Return the files of a statement about a resolved scenario that has bounds by quadratic forms.

    Raises:
        CallerError: nothing is proven, or there is no loop document; the message says why.
    """
    loop, document = _proven(statement)
    try:
        return proof_files(loop, document, naming_of(resolved, statement))
    except NoDocumentError as error:
        raise CallerError(f"there is no loop document: {error}") from None


def files_of_widest(resolved: Scenario, witnesses: Witnesses) -> ProofFiles | GainsFiles:
    """Return the files of the statement that covers most: see :func:`widest`.

    If it rests on small gains alone, they are those of the verifier of bounds by gains.

    Raises:
        CallerError: as :func:`loop_files`.
    """
    statement = widest(witnesses)
    loop, document = _proven(statement)
    if document.get("bounds"):
        return loop_files(resolved, statement)
    try:
        return gains_files(loop, document, naming_of(resolved, statement))
    except NoDocumentError as error:
        raise CallerError(f"there is no document: {error}") from None


def gains_of_widest(resolved: Scenario, witnesses: Witnesses) -> GainsFiles | None:
    """Return the files of the bounds by gains that a statement has beside its forms; None: it has none.

    Raises:
        CallerError: nothing is proven.
    """
    statement = widest(witnesses)
    loop, document = _proven(statement)
    if not document.get("bounds") or "gains" not in document:
        return None
    try:
        return gains_files(loop, document, naming_of(resolved, statement))
    except NoDocumentError:
        return None


def _proven(statement: WitnessedStatement) -> tuple[Loop, dict[str, object]]:
    if statement.document is None or statement.loop is None:
        raise CallerError(f"there is no proof: {statement.reason}")
    return statement.loop, statement.document


def widest(witnesses: Witnesses) -> WitnessedStatement:
    """Return the statement with a loop document that covers most: all plants if possible, by the schedule."""
    statements = [s for s in witnesses.statements if s.conditions == "schedule"] or [*witnesses.statements]
    proven = [s for s in statements if s.document is not None and s.document.get("bounds")]
    return (proven or statements)[-1]


def naming_of(resolved: Scenario, statement: WitnessedStatement) -> Naming:
    """Return how the document of a statement names its loop."""
    loop = loop_of(resolved)
    of = f"{resolved.name}: {_PLANTS[statement.plants]} under {_CONDITIONS[statement.conditions]}"
    outputs = [output.name for output in loop.outputs]
    output_units = [output.unit for output in loop.outputs]
    return Naming(of, loop.state_names, outputs, resolved.model.state_units or (), output_units)
