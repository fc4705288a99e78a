"""What processes tell each other over the control plane, as JSON; whoever reads it checks it.

Whatever else reaches the plane, or a damaged file, is none of it and must not end a process.
"""

import re
from ipaddress import ip_address
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    JsonValue,
    ValidationError,
)

from noack.config.validation_messages import brief
from noack.core.errors import PeerError

Count = Annotated[int, Field(ge=0, lt=2**63)]
Nanoseconds = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Generation = Annotated[int, Field(ge=0, lt=2**20)]
Ranges = tuple[tuple[Count, Count], ...]
"""Half-open ranges of numbers."""


class ControlMessage(BaseModel):
    """A message; it may say more."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow")


def _require_number(host: str) -> str:
    ip_address(host)  # of a name nobody knows how long its look-up takes
    return host


SocketAddress = tuple[
    Annotated[str, AfterValidator(_require_number)], Annotated[int, Field(ge=1, le=65_535)]
]
"""An address: host, as a number, and port."""


class AdmissionRequest(ControlMessage):
    """A process asks whether it may join."""

    instance: str
    """Tells it from another of its role."""


class Admission(ControlMessage):
    """The coordinator says who a process is in the run."""

    generation: Generation
    """How many of its role were in the run before it."""
    admitted_ns: Nanoseconds
    """Simulated time at which it was let in; whatever is older was for the one before it."""
    from_ns: Nanoseconds
    """When it is to take up its work."""
    address: SocketAddress | None
    """Where the one before it received, and now it."""
    after: str | None
    """What became of the one before it."""


class JoinRequest(ControlMessage):
    """A process is ready to start."""

    instance: str
    address: SocketAddress | None
    """Where it receives; None for the recorder."""


class ChangeAnnouncement(ControlMessage):
    """The coordinator says what is changed, and from when on."""

    number: Count
    """Of the run's changes."""
    t_ns: Count
    """Simulated time from which on it is in force."""
    settings: dict[str, JsonValue]
    """Values by keys of the scenario."""
    said_ns: Nanoseconds
    """Simulated time at which it was asked for."""
    said_at: str
    """The same by the calendar, or that the scenario says so."""


class ChangeRequest(ControlMessage):
    """A person asks for a change of settings; or, with none, what they are."""

    settings: dict[str, JsonValue] = Field({})
    """Values by keys of the scenario."""


class ChangeReply(ControlMessage):
    """The coordinator answers what is asked of a run's settings."""

    name: str
    run_dir: str
    t_s: FiniteFloat
    """Simulated time."""
    from_s: FiniteFloat | None
    """From when on what was asked for is in force; None if nothing was."""
    runtime_parameters: dict[str, JsonValue]
    """Values by keys, with all changes that have been announced."""


class RunStart(ControlMessage):
    """The coordinator says that the run begins, or has begun."""

    epoch_ns: Count
    """Monotonic clock reading at simulated time 0."""
    addresses: dict[str, SocketAddress]
    """Where each process receives."""
    changes: tuple[ChangeAnnouncement, ...] = ()
    """What is known by now of changes."""


class BatchHeader(ControlMessage):
    """A batch of rows."""

    first: Count
    """Number of its first row in its table, of those of this generation."""
    generation: Generation = 0


class PersistedAck(ControlMessage):
    """The recorder says what it has on disk of an generation of a process."""

    generation: Count
    rows: dict[str, Ranges]
    """By table."""


class MissingRows(ControlMessage):
    """The recorder says what it lacks of a process that says goodbye."""

    rows: dict[str, Ranges]
    """By table."""


class LogLine(ControlMessage):
    """A line of a process for the run's log."""

    t_ns: Nanoseconds
    level: str
    text: str


class ChannelCounters(ControlMessage):
    """Counters of what a process hears."""

    rejected: dict[str, Count] = Field({})
    """Datagrams by reason."""
    acknowledgements: "ChannelCounters | None" = None


class ProcessReport(ControlMessage):
    """What a process says at its end."""

    ended: str
    """Why it ended."""
    channel: ChannelCounters
    rows: dict[str, Count]
    """How many it made, by table."""
    generation: Count = 0
    instance: str = ""
    """Tells it from another of its role."""
    realtime: dict[str, str] = Field({})
    """Each real-time setting, and whether it was granted."""
    reached_ns: Nanoseconds | None = None
    """Simulated time up to which it had done what was due; None if it failed."""


class RunProgress(ControlMessage):
    """The recorder's account of a run under way."""

    t_s: FiniteFloat
    events: Count
    deliveries: Count
    longest_loss_burst: Count
    x_norm: float | None
    live: str | None
    void: list[str] = []
    """Why claims about the run are void already, as far as is known, or why that is not known."""
    changes: list[str] = []
    """What was changed during the run."""


M = TypeVar("M", bound=ControlMessage)


def parse_message(kind: type[M], payload: bytes | str) -> dict[str, Any]:
    """Return what a message says.

    Raises:
        PeerError: it is none of this kind.
    """
    try:
        return kind.model_validate_json(payload).model_dump(exclude_unset=True)
    except ValidationError as error:
        name = re.sub("(?<=[a-z])(?=[A-Z])", " ", kind.__name__).strip("_").lower()
        raise PeerError(f"no {name} of this version of noack: {brief(error)}") from None
