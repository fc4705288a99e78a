"""The file of a fate trace: Parquet with a row for each datagram that came in, in that order.

========================= =====================================================================
column
========================= =====================================================================
``link``, ``direction``   where it came in; ``forward`` is from client to server
``flow``, ``packet``      number of its flow, and its number in the flow, from 0
``arrival_ns``            when it came, in Unix time
``size_bytes``            of the payload
``fate``                  :class:`noack.protocol.record_tables.Fate`
``run``                   successive datagrams, up to it, that are not effectively delivered
``delay_ns``              from its arrival until it leaves; −1 never
``copy_delay_ns``         the same of its duplicate; −1 if there is none
``bit``, ``copy_bit``     which bit of it, and of its duplicate, is flipped; −1 none
``hold_back_ns``               by how much it is held back so that the cap holds
========================= =====================================================================

The file's metadata has a JSON document under ``noack``: the version that wrote it, the links with
their seeds and their settings at the start, and how many events are missing.
"""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
import pyarrow as pa

from netem.engine.relay_interface import DIRECTIONS, LinkSpec

FORMAT = 1
METADATA = "noack"

NUMBERS: Mapping[str, str] = {
    "flow": "int64",
    "packet": "int64",
    "arrival_ns": "int64",
    "size_bytes": "int32",
    "fate": "int8",
    "run": "int32",
    "delay_ns": "int64",
    "copy_delay_ns": "int64",
    "bit": "int32",
    "copy_bit": "int32",
    "hold_back_ns": "int64",
}
"""Columns of numbers and their types."""

_NAMES = pa.dictionary(pa.int16(), pa.string())
SCHEMA = pa.schema(
    [("link", _NAMES), ("direction", _NAMES)]
    + [(name, pa.from_numpy_dtype(np.dtype(kind))) for name, kind in NUMBERS.items()]
)


def description(specs: Sequence[LinkSpec], missing: int) -> dict[str, str]:
    """Return the metadata of a trace."""
    document: Mapping[str, Any] = {
        "format": FORMAT,
        "version": version("noack"),
        "missing_events": missing,
        "links": [
            {
                "name": spec.name,
                "seed": spec.seed,
                **{name: getattr(spec, name).model_dump(mode="json") for name in DIRECTIONS},
            }
            for spec in specs
        ],
    }
    return {METADATA: json.dumps(document)}
