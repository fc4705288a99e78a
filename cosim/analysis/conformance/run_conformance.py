"""The conformance of a recorded loop with the loop document of its scenario's bounds."""

from cosim.analysis.claims.common_end import up_to_common_end
from cosim.analysis.claims.reference_deviations import deviations
from cosim.analysis.conformance.conformance import Conformance, compare
from cosim.analysis.conformance.trace import trace_of
from cosim.analysis.loop_files import naming_of, widest
from cosim.analysis.witnesses import WitnessedStatement, find_witnesses, plants_of
from cosim.record.run_record import RunRecord
from noack.core.errors import CallerError
from noack.proof.files import document_of
from noack.proof.loop_document import NoDocumentError
from noack.scenario.resolution import loop_of


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
        document = document_of(statement.loop, statement.document, naming_of(record.scenario, statement))
        whole = up_to_common_end(record)
        if (reference := loop_of(record.scenario).reference) is not None:
            whole = deviations(whole, reference)
        return compare(trace_of(whole, document), document.table)
    except NoDocumentError as error:
        raise CallerError(f"there is no loop document: {error}") from None
