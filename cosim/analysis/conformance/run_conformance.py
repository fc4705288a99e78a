"""The conformance of a recorded loop with the loop document of its scenario's bounds."""

from dataclasses import replace

import numpy as np

from cosim.analysis.conformance.common_end import up_to_common_end
from cosim.analysis.conformance.conformance import compare
from cosim.analysis.conformance.recorded_loop import RecordedLoop
from cosim.analysis.conformance.run_document import RunDocument, document_of_statement
from cosim.analysis.conformance.trace import trace_of
from cosim.analysis.conformance.verdicts import Conformance
from cosim.analysis.loop_files import naming_of, widest
from cosim.analysis.witnesses import WitnessedStatement, find_witnesses, plants_of
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from noack.core.references import Reference
from noack.proof.loop_document import NoDocumentError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario


def conformance_of(record: RunRecord, plants: str | None = None) -> Conformance:
    """Return whether a recorded loop is a run of the document of its bounds, which are known already.

    Args:
        record: of the loop; of a stopped run, it is compared up to its common end.
        plants: "own", "box" or "region"; by default those of the document that ``noack certify`` writes: all
            plants within the uncertainty, if they have one.

    Raises:
        CallerError: no document describes the loop, or it cannot be compared yet; the message says why.
    """
    scenario = record.scenario
    if (known := plants_of(scenario)) == ["region"] and plants not in (None, "region"):
        raise CallerError("--plants: a plant given by equations has one document; leave the option out")
    of = known if plants is None else [plants]
    return conformance_with(
        record, widest(find_witnesses(scenario, most_work=0.0, conditions=("schedule",), plants=of))
    )


def conformance_with(record: RunRecord, statement: WitnessedStatement) -> Conformance:
    """Return whether a recorded loop is a run of the document of a statement.

    Raises:
        CallerError: as :func:`conformance_of`.
    """
    if statement.document is None or statement.loop is None:
        raise CallerError(
            f"nothing is proved of the loop, so there is no loop document to compare: {statement.reason}"
        )
    try:
        document = document_of_statement(statement, naming_of(record.scenario, statement))
    except NoDocumentError as error:
        raise CallerError(f"there is no loop document: {error}") from None
    return conformance(record, document)


def conformance(record: RunRecord, document: RunDocument) -> Conformance:
    """Return whether a recorded loop is a run of a document.

    Args:
        record: of the loop; of a stopped run, it is compared up to its common end.
        document: of the loop.

    Raises:
        CallerError: the record cannot be compared with the document; the message says why.
    """
    recorded = RecordedLoop(up_to_common_end(record))
    return conformance_of_loop(recorded, document, reference_of_bounds(record.scenario))


def conformance_of_loop(
    recorded: RecordedLoop, document: RunDocument, reference: Reference | None
) -> Conformance:
    """Return whether a recorded loop is a run of a document.

    Args:
        recorded: what is read of its record.
        document: of the loop.
        reference: what the bounds are about.

    Raises:
        CallerError: the record cannot be compared with the document; the message says why.
    """
    trace = trace_of(recorded, document, reference)
    found = compare(trace, document.numbers)
    if (failure := found.failure) is None:
        return found
    step = int(np.searchsorted(trace.t_ns, round(failure.t_s * NS_PER_S)))
    age_s = float(trace.t_ns[step] - recorded.inputs.input_ns[step]) / NS_PER_S
    sources = {edge["name"]: edge["from"] for edge in document.table["edges"]}
    at = document.places.get(sources.get(failure.place, failure.place))
    return found._replace(failure=replace(failure, at=at, input_age_s=age_s))


def reference_of_bounds(scenario: Scenario) -> Reference | None:
    """Return what the bounds of a scenario are about: its reference, or its rest under constant loads."""
    loop = loop_of(scenario)
    if loop.reference is None and loop.loads:
        return Reference.constant(loop.rest, loop.K @ loop.rest)
    return loop.reference
