"""Whether a run is a run of its loop document: the verdict, and what the run shows of the document."""

from cosim.analysis.conformance.verdicts import Conformance
from cosim.analysis.summary.summary_model import ConformancePart
from cosim.output.conformance_words import conformance_text, failure_text
from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import ResultTable, Tone


def conformance_document(found: Conformance, name: str) -> Document:
    """Return the verdict about a loop of some name, and tables of what its run shows of the document."""
    tone, part = Tone.GOOD if found.conforms else Tone.BAD, ConformancePart.of(found, "")
    shares = [(place, f"{100 * share:.0f} %") for place, share in found.clocks.items()]
    return Document(
        title=f"conformance of {name}",
        data={
            "document": found.document,
            "conforms": found.conforms,
            "until_s": found.until_s,
            "reason": "" if part.failure is None else failure_text(part.failure),
            "failure": None if part.failure is None else part.failure.model_dump(mode="json"),
            "transitions": dict(found.edges),
            "clock_shares": dict(found.clocks),
        },
        blocks=[
            Sentence(text=conformance_text(part), role=SentenceRole.VERDICT, tone=tone, is_prose=True),
            ResultTable(
                "",
                "transitions that the document allows, and how often each occurred",
                ("transition", "occurred"),
                [(edge, f"{count:,}") for edge, count in found.edges.items()],
            ),
            ResultTable(
                "",
                "largest share of each location's time limit that the run reached",
                ("location", "share"),
                shares,
            ),
        ],
    )
