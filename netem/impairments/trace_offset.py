"""Where in a trace a feature begins: at a time, or at a random place."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from netem.core.clock import NS_PER_S
from netem.core.named_file import NamedFile
from netem.core.random_streams import uniform_pair
from netem.impairments.feature import StageTables
from netem.impairments.words import OWN_TIME_S, Quantity, time_text

Offset = Annotated[FiniteFloat, Field(ge=0, le=1e9)] | Literal["random"]
"""In seconds after the trace's first packet."""


def _offset(word: str) -> float | str:
    return word if word == "random" else OWN_TIME_S.read(word)


OFFSET = Quantity(
    f"{OWN_TIME_S.expected}; or random",
    _offset,
    lambda offset: offset if isinstance(offset, str) else time_text(offset),
)
"""The place in a trace at which a feature begins."""


def offset_meaning(offset: float | str) -> str:
    """Return where the trace begins, in plain words."""
    if isinstance(offset, str):
        return ", from a place that the seed chooses"
    return f", from {time_text(offset)} after its beginning" if offset else ""


def require_inside(offset: float | str, length_ns: int, file: NamedFile | None = None) -> None:
    """Raise ValueError if an offset is not inside a trace of this length; CallerError of a file."""
    if not isinstance(offset, str) and round(offset * NS_PER_S) >= max(length_ns, 1):
        message = f"offset_s: the trace lasts {time_text(length_ns / NS_PER_S)}"
        if file is not None:
            file.wrong(message)
        raise ValueError(message)


def offset_ns(offset: float | str, length_ns: int, tables: StageTables) -> int:
    """Return an offset in ns; a random one is uniform over the trace, for all flows the same."""
    if isinstance(offset, str):
        share, _ = uniform_pair(*tables.key)
        return int(share * length_ns)
    return round(offset * NS_PER_S)
