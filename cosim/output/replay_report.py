"""What a replay found: each process and hop compared bit for bit, and the first difference."""

from collections.abc import Iterator, Sequence

from cosim.analysis.replay.replay_result import ReplayResult
from cosim.analysis.summary.summary_model import ReplayDifference
from netem.output.document import Block, Document, Sentence
from netem.output.result_tables import ResultTable, Tone

_DIFFERENT = "≠"


def replay_document(replay: ReplayResult, changed: Sequence[str]) -> Document:
    """Return the result of a replay, and what ``changed`` since the run on its computer."""
    return Document(
        title="replay",
        data=replay.to_json() | {"changed_since": changed},
        blocks=[*_blocks(replay, changed)],
    )


def _blocks(replay: ReplayResult, changed: Sequence[str]) -> Iterator[Block]:
    parts = [(part.process, part.inputs, part.compared, part.difference) for part in replay.processes]
    parts += [(part.hop, part.received, part.compared, part.difference) for part in replay.messages]
    yield ResultTable(
        "",
        "replay, compared bit for bit",
        ("process or hop", "recorded", "compared", "verdict"),
        [
            (name, f"{recorded:,}", f"{compared:,}", _verdict(compared, difference))
            for name, recorded, compared, difference in parts
        ],
        tones={_DIFFERENT: Tone.BAD},
    )
    for gap in replay.gaps:
        yield Sentence(lead="record incomplete:", text=gap, tone=Tone.DOUBTFUL)
    if (first := replay.first_difference) is None:
        word = f"bit-exact: {replay.inputs:,} inputs" if replay.inputs else "nothing to compare"
        yield Sentence(text=word + (" so far as the record goes" if replay.gaps else ""))
        return
    yield Sentence(lead="first difference:", text=str(first), tone=Tone.BAD)
    for change in changed:
        yield Sentence(
            lead="not the machine of the run:",
            text=f"{change}; the last bits of a product may depend on it",
            tone=Tone.DOUBTFUL,
        )


def _verdict(compared: int, difference: ReplayDifference | None) -> str:
    if difference is not None:
        cell = f"{difference.table}[{difference.row}].{difference.column}".rstrip(".")
        return f"{_DIFFERENT} {cell}"
    return "bit-exact" if compared else "-"
