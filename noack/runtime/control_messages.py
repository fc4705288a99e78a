"""Messages of the control plane, as JSON. The reader checks each of them.

Any other input, such as a damaged file, is refused and must not end a process.
"""

import re
from ipaddress import ip_address
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, JsonValue, ValidationError
from pydantic_core import to_json

from netem.core.errors import PeerError
from netem.core.settings_section import Table
from netem.core.toml_file import brief
from noack.scenario.parameter_changes import ParameterChange

Count = Annotated[int, Field(ge=0, lt=2**63)]
Nanoseconds = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Ranges = tuple[tuple[Count, Count], ...]  # half-open ranges of numbers


class ControlMessage(BaseModel):
    """A message; further fields are allowed."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow", defer_build=True)

    def fields(self) -> Table:
        """Return the fields that were given, also further ones, for JSON."""
        return self.model_dump(exclude_unset=True)


def _require_number(host: str) -> str:
    ip_address(host)  # the look-up of a name could take arbitrarily long
    return host


NumericHost = Annotated[str, AfterValidator(_require_number)]
SocketAddress = tuple[NumericHost, Annotated[int, Field(ge=1, le=65_535)]]
"""Numeric host and port."""


class ClockError(ControlMessage):
    """How far the clock of a process's host may be off."""

    clock: str  # name of the monotonic clock: processes with the same name share it
    error_ns: Count  # of the host's CLOCK_REALTIME
    source: str  # where this bound is from


class AdmissionRequest(ControlMessage):
    """A process asks for admission to the run."""

    instance: str  # random name of this process
    clock: ClockError | None = None  # None: it reads the coordinator's


class Admission(ControlMessage):
    """The coordinator admits a process."""


class JoinRequest(ControlMessage):
    """A process is ready and waits at the start barrier."""

    instance: str
    address: SocketAddress | None  # its receiving address; None for the recorder


class ChangeAnnouncement(ControlMessage):
    """The coordinator announces a change of runtime parameters."""

    number: Count  # numbers the changes of the run from 0
    t_ns: Count  # simulated time from which it applies
    settings: Table  # values by scenario key
    requested_ns: Nanoseconds  # simulated time of the request
    requested_at: str  # date and time of the request; or that the scenario contains the change
    target_losses: dict[str, FiniteFloat] = {}
    """Probabilities for :func:`netem.impairments.target_loss.store_probabilities`."""

    @property
    def change(self) -> ParameterChange:
        """The change."""
        return ParameterChange(self.number, self.t_ns, self.settings)


class ChangeRequest(ControlMessage):
    """A user requests a change of runtime parameters; without settings, their values."""

    settings: dict[str, JsonValue] = Field({})


class ChangeReply(ControlMessage):
    """The coordinator answers a change request."""

    name: str
    run_dir: str
    t_s: FiniteFloat
    from_s: FiniteFloat | None
    """Simulated time from which the change applies; None if none was requested, or the values are in
    force already."""
    runtime_parameters: Table
    """Values by scenario key, all announced changes included."""
    loops: dict[str, Table]
    """The same for the loops of each entry of [[loops]], by its name."""
    changed_loops: tuple[str, ...]
    """The entries with another value than before the request."""
    warnings: tuple[str, ...] = ()
    """The assumptions of the theory that the change violates."""
    thresholds: dict[str, tuple[FiniteFloat, FiniteFloat]] = {}
    """The threshold of ‖e_s‖ at ``from_s`` without and with the change, by entry of [[loops]]; only of
    the triggers that have one, and that were changed."""


class RunStart(ControlMessage):
    """The coordinator lets a process pass the start barrier."""

    epoch_ns: Count  # reading of the coordinator's CLOCK_MONOTONIC at simulated time 0
    epoch_realtime_ns: Count  # of its CLOCK_REALTIME
    clocks: dict[str, ClockError] = {}  # of all processes of the loop; empty if they read the same one
    addresses: dict[str, SocketAddress]
    changes: tuple[ChangeAnnouncement, ...] = ()  # the changes announced so far


class BatchHeader(ControlMessage):
    """Header of a batch of rows."""

    first: Count  # number of its first row among its process's rows of the table


class PersistedAck(ControlMessage):
    """The recorder confirms the rows of a process that are on disk."""

    rows: dict[str, Ranges]


class MissingRows(ControlMessage):
    """The recorder answers a final report with the rows that it misses."""

    rows: dict[str, Ranges]


class LogLine(ControlMessage):
    """A line for the run's log."""

    t_ns: Nanoseconds
    level: str
    text: str
    loop: Count | None = None  # in a run of several loops, that it is about


class ChannelCounters(ControlMessage):
    """Counters of received datagrams: rejected ones by reason."""

    rejected: dict[str, Count] = Field({})
    acknowledgements: "ChannelCounters | None" = None


class ProcessReport(ControlMessage):
    """Final report of a process."""

    ended: str  # the reason
    channel: ChannelCounters
    rows: dict[str, Count]  # number of recorded rows, by table
    stored: dict[str, Ranges] = {}
    """Those of them that the process has written to disk itself, by table."""
    instance: str = ""
    clock: ClockError | None = None  # in a run with several clocks
    realtime: dict[str, str] = Field({})  # whether each real-time setting was applied
    reached_ns: Nanoseconds | None = None
    """Simulated time up to which all its deadlines were served; None if it failed."""


class RunProgress(ControlMessage):
    """The recorder's progress report during the run: of all loops together; ‖x‖ is the largest."""

    t_s: FiniteFloat
    events: Count
    deliveries: Count
    longest_loss_burst: Count
    x_norm: float | None
    late_us: FiniteFloat = 0.0
    """The largest lateness of a step of the plant or the controller, in microseconds of wall time."""
    live: str | None
    warnings: list[str] = Field([])
    """What cannot be shown during the run; messages that arrived before they were sent."""
    changes: list[str] = Field([])  # changes of runtime parameters during the run


M = TypeVar("M", bound=ControlMessage)


def message_json(content: object) -> bytes:
    """Return a message, or fields of one, as JSON."""
    return to_json(content, inf_nan_mode="constants")


def parse_message(kind: type[M], payload: bytes | str) -> M:
    """Return a message; raise PeerError if the payload is not one of this kind."""
    try:
        return kind.model_validate_json(payload)
    except ValidationError as error:
        name = re.sub("(?<=[a-z])(?=[A-Z])", " ", kind.__name__).strip("_").lower()
        raise PeerError(f"not a valid {name}: {brief(error)}") from None
