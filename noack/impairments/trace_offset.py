"""Where in a trace an impairment begins: at a given time, or at one drawn from a random stream."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from noack.core.clock import NS_PER_S
from noack.core.random_streams import uniform_pair
from noack.impairments.feature import StageTables
from noack.impairments.quantities import OWN_TIME_S, time_text
from noack.impairments.word_reader import WordReader
from noack.settings.user_files import NamedFile

Offset = Annotated[FiniteFloat, Field(ge=0, le=1e9)] | Literal["random"]
"""In seconds after the trace's first packet."""
LONGEST_NS = 10**18
"""Longest trace: 31 years."""


def read_offset(reader: WordReader) -> float | str:
    """Read the word after ``from``."""
    return "random" if reader.accept("random") else reader.value(OWN_TIME_S)


def offset_text(offset: float | str) -> str:
    """Return the words of an offset; none if the trace is used from its beginning."""
    if offset == 0:
        return ""
    return f" from {offset if isinstance(offset, str) else time_text(offset)}"


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
