"""The loop document of a proven statement and the proof of its bounds: two files, which the kernel reads."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from cosim.analysis.witnesses import WitnessedStatement, Witnesses
from noack.core.errors import CallerError
from noack.proof.forms_proof import as_text, write_proof
from noack.proof.loop_document import LoopDocument, Naming, NoDocumentError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack_check.document import read_number
from noack_check.proof import read_assumptions

_PLANTS = {"own": "the plant", "box": "all plants of its uncertainty", "region": "the plant's equations"}
_CONDITIONS = {"schedule": "its schedule", "ideal": "ideal conditions"}


class LoopFiles(NamedTuple):
    """A loop document and a proof of its bounds."""

    table: Mapping[str, Any]
    """The document."""
    document: str
    proof: str
    """The contents of the files."""


def loop_files(resolved: Scenario, statement: WitnessedStatement) -> LoopFiles:
    """Return the files of a statement about a resolved scenario.

    Raises:
        CallerError: nothing is proven, the bounds are not by quadratic forms, or no document describes the
            loop; the message says which.
    """
    content, loop = statement.document, statement.loop
    if content is None or loop is None:
        raise CallerError(f"there is no proof: {statement.reason}")
    bounds = content.get("bounds")
    if not isinstance(bounds, list) or not bounds:
        raise CallerError("the bounds are by gains; only bounds by quadratic forms have a loop document")
    rate = read_number(content, "rate")
    assumed = read_assumptions(loop, rate, content)
    try:
        outputs = [str(bound["output"]) for bound in bounds]
        document = LoopDocument(loop, rate, assumed, outputs, _naming(resolved, statement))
        proof = write_proof(document, bounds)
    except NoDocumentError as error:
        raise CallerError(f"there is no loop document: {error}") from None
    return LoopFiles(document.table, as_text(document.table), as_text(proof))


def files_of_widest(resolved: Scenario, witnesses: Witnesses) -> LoopFiles:
    """Return the files of the statement that covers most: under the schedule, of all plants if possible.

    Raises:
        CallerError: as :func:`loop_files`, of the statement that covers most.
    """
    statements = [s for s in witnesses.statements if s.conditions == "schedule"] or [*witnesses.statements]
    proven = [s for s in statements if s.document is not None and s.document.get("bounds")]
    return loop_files(resolved, (proven or statements)[-1])


def _naming(resolved: Scenario, statement: WitnessedStatement) -> Naming:
    loop = loop_of(resolved)
    outputs = loop.outputs
    units = dict(zip(loop.state_names, resolved.model.state_units or (), strict=False))
    units |= {output.name: output.unit for output in outputs}
    of = f"{resolved.name}: {_PLANTS[statement.plants]} under {_CONDITIONS[statement.conditions]}"
    return Naming(of, loop.state_names, [output.name for output in outputs], units)
