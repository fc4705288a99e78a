"""Fate traces: a valid trace with edits of its table, its document or its bytes."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from netem.fates import METADATA, SCHEMA, description, read_fates
from netem.relay.relay_links import LinkSpec
from netem.tc_words import settings_of
from noack.impairments.link_settings import LinkSettings
from tests.fuzz.edits import Choices, Vocabulary, edited, edited_table, written
from tests.fuzz.harness import Harness, refusal, workspace
from tests.oracles.link import Link

_LATEST_NS = 2**62
"""Later than every arrival: a century of Unix time."""
SPECS = [
    LinkSpec("up", ("127.0.0.1", 9000), ("127.0.0.1", 9001), settings_of("loss 5% mansd 2"),
             LinkSettings()),
    LinkSpec("down", ("127.0.0.1", 9002), ("127.0.0.1", 9003), LinkSettings(), LinkSettings()),
]  # fmt: skip
DOCUMENT: dict[str, Any] = json.loads(description(SPECS, 0)[METADATA])
KNOWN = Vocabulary((*DOCUMENT, "name", "forward", "reverse", "mansd", "seed"), ("up", "down", "1", ""))


def _rows() -> pa.Table:
    """Rows of a relay: lost, delivered, late, duplicated, corrupted, overflowed."""
    rows = [
        # link, direction, flow, packet, arrival, size, fate, consecutive losses, delay, copy delay,
        # bit, copy bit, hold-back
        ("up", "forward", 0, 0, 10, 100, 0, 0, 5, -1, -1, -1, 0),
        ("up", "forward", 0, 1, 20, 100, 1, 1, -1, -1, -1, -1, 0),
        ("up", "forward", 1, 0, 21, 100, 4, 1, -1, -1, -1, -1, 0),
        ("up", "forward", 0, 2, 30, 100, 3, 2, 7, 9, 13, -1, 0),
        ("up", "reverse", 0, 0, 35, 100, 0, 0, 0, -1, -1, -1, 0),
        ("up", "forward", 0, 3, 40, 100, 2, 0, 5, -1, -1, -1, 3),
    ]
    columns = zip(*rows, strict=True)
    return pa.table([pa.array(c, f.type) for c, f in zip(columns, SCHEMA, strict=True)], SCHEMA)


TABLE = _rows()


def fates_input(data: bytes) -> None:
    """A trace of fates is refused, or can be replayed."""
    choices = Choices(data)
    document: Any = edited(choices, DOCUMENT, KNOWN) if choices.flag() else DOCUMENT
    text = json.dumps(document)
    if choices.below(8) == 1:
        text = choices.choose(["", "[]", "null", "{", text[:-1]])
    metadata = {METADATA: text} if choices.below(8) != 1 else {}
    path = workspace() / "fates.parquet"
    links = choices.choose([None, ["up"], ["up", "nobody"], ["down"]])
    path.write_bytes(written(choices, edited_table(choices, TABLE), metadata))
    with refusal(str(path)):
        _replay(path, links)


def _replay(path: Path, links: list[str] | None) -> None:
    """Replay the decisions of a trace; every accepted trace must be replayable."""
    fates = read_fates(path, links)
    for direction, flows in fates.decisions.items():
        link = Link(LinkSettings(**fates.guarantees[direction]), 0, *direction, decisions=flows)
        for flow, decisions in enumerate(flows):
            for _, delay_ns, copy_delay_ns, *_ in decisions:
                # The compiled relay adds in signed 64 bits.
                assert _LATEST_NS + int(max(delay_ns, copy_delay_ns)) < 2**63
                link.decide(flow, 100, 0)


PARSERS = {
    "fates": Harness(fates_input),
}
