"""What processes tell each other over the control plane, as JSON; whoever reads it checks it.

Whatever else reaches the plane, or a damaged file, is none of it and must not end a process.
"""

import re
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from noack.errors import PeerError
from noack.mistakes import brief

Count = Annotated[int, Field(ge=0, lt=2**63)]


class Said(BaseModel):
    """A message; it may say more."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow")


class Hello(Said):
    """A process asks to join."""

    address: tuple[str, Annotated[int, Field(ge=1, le=65_535)]] | None
    """Where it receives; None for the recorder."""


class BatchHeader(Said):
    """A batch of rows."""

    first: Count
    """Number of its first row in its table."""


class LogLine(Said):
    """A line of a process for the run's log."""

    t_ns: Annotated[int, Field(ge=-(2**63), lt=2**63)]
    level: str
    text: str


class Channel(Said):
    """Counters of what a process hears."""

    rejected: dict[str, Count] = Field({})
    """Datagrams by reason."""
    acknowledgements: "Channel | None" = None


class Report(Said):
    """What a process says at its end."""

    ended: str
    """Why it ended."""
    channel: Channel
    rows: dict[str, Count]
    """How many it made, by table."""
    realtime: dict[str, str] = Field({})
    """Each real-time setting, and whether it was granted."""


class Progress(Said):
    """The recorder's account of a run under way."""

    t_s: FiniteFloat
    events: Count
    deliveries: Count
    longest_drop_run: Count
    x_norm: float | None
    live: str | None


M = TypeVar("M", bound=Said)


def heard(kind: type[M], payload: bytes | str) -> dict[str, Any]:
    """Return what a message says.

    Raises:
        PeerError: it is none of this kind.
    """
    try:
        return kind.model_validate_json(payload).model_dump(exclude_unset=True)
    except ValidationError as error:
        name = re.sub("(?<=[a-z])(?=[A-Z])", " ", kind.__name__).strip("_").lower()
        raise PeerError(f"no {name} of this version of noack: {brief(error)}") from None
