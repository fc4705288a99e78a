"""The file of a fate trace: Parquet with a row for each received datagram, in order of arrival.

========================= =====================================================================
column
========================= =====================================================================
``link``, ``direction``   where it arrived; ``forward`` is from client to server
``flow``, ``packet``      number of its flow, and its number in the flow, from 0
``arrival_ns``            time of arrival, Unix time
``size_bytes``            size of the payload
``fate``                  :class:`noack.protocol.record_tables.Fate`
``consecutive_losses``    length of the loss burst that ends with it; 0 if it is delivered
``delay_ns``              from arrival to departure; −1: never forwarded
``copy_delay_ns``         the same for its duplicate; −1: no duplicate
``bit``, ``copy_bit``     flipped bit of it, and of its duplicate; −1: none
``hold_back_ns``          time for which the guarantee holds it back
========================= =====================================================================

The file's metadata has a JSON document under ``noack``: the version of the program, the links with
their seeds and their settings at the start, and the number of missing events.
"""

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
import pyarrow as pa

from netem.engine.relay_interface import DIRECTIONS, LinkSpec

FORMAT = 2
METADATA = "noack"

NUMBERS: Mapping[str, str] = {
    "flow": "int64",
    "packet": "int64",
    "arrival_ns": "int64",
    "size_bytes": "int32",
    "fate": "int8",
    "consecutive_losses": "int32",
    "delay_ns": "int64",
    "copy_delay_ns": "int64",
    "bit": "int32",
    "copy_bit": "int32",
    "hold_back_ns": "int64",
}
"""Numeric columns and their types."""

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
