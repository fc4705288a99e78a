"""The roles of a loop: the flows that each receives and sends, and what its machine emits besides.

Updates cross the network between sensor and controller. Acknowledgements of the baseline, or
actuations, may cross it, too (:mod:`noack.scenario.sections`).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from noack.core.linear_systems import Vector
from noack.protocol.wire_format import Flow, Message

RECEIVES: Mapping[str, Flow] = {
    "plant": Flow.ACTUATION,
    "sensor": Flow.MEASUREMENT,
    "netem": Flow.UPDATE,
    "controller": Flow.UPDATE,
}
"""The flow that each process receives in every run."""
SENDS: Mapping[str, Flow] = {
    "plant": Flow.MEASUREMENT,
    "sensor": Flow.UPDATE,
    "netem": Flow.UPDATE,
    "controller": Flow.ACTUATION,
}
"""The flow that each process sends in every run."""
PAPER = (Flow.UPDATE,)
"""Flows that cross the network in the paper's loop."""
LOOP_ROLES = tuple(RECEIVES)
PLANT = "plant"
WITH_DEADLINES = ("plant", "controller")  # processes that act at nominal times
CHANGEABLE = ("sensor", "netem", "controller")  # processes with runtime parameters
RECORDER = "recorder"
COORDINATOR = "coordinator"
ROLES = (*LOOP_ROLES, RECORDER)


class Ends(NamedTuple):
    """The first sender of a flow and its last receiver."""

    sender: str
    receiver: str


ENDS: Mapping[Flow, Ends] = {
    Flow.MEASUREMENT: Ends("plant", "sensor"),
    Flow.UPDATE: Ends("sensor", "controller"),
    Flow.ACTUATION: Ends("controller", "plant"),
    Flow.ACKNOWLEDGEMENT: Ends("controller", "sensor"),
}


def receiver_of(role: str, flow: Flow, network: Collection[Flow] = PAPER) -> str:
    """Return to which role a process sends a flow; ``network`` has the flows that cross the network."""
    return "netem" if flow in network and role != "netem" else ENDS[flow].receiver


def sender_to(role: str, flow: Flow, network: Collection[Flow] = PAPER) -> str:
    """Return from which role a process receives a flow; ``network`` likewise."""
    return "netem" if flow in network and role != "netem" else ENDS[flow].sender


@dataclass(frozen=True)
class LoopProtocol:
    """A protocol of the loop."""

    acknowledges: bool
    """Whether updates are acknowledged, and x_s is reset by acknowledgements only.

    Then the paper's theorems do not apply, and settings cannot change during a run.
    """
    states_caption: str
    """When x_s and x_c jump, for readers; ``{known}`` is the state that they jump to."""
    error_caption: str  # when the sensor's error is reset, for readers
    summary: str  # one sentence for readers
    reset: str  # when x_s is reset, for readers


PROTOCOLS: Mapping[str, LoopProtocol] = {
    "none": LoopProtocol(
        acknowledges=False,
        states_caption="At every event x_s jumps to {known}; x_c does so only when the update arrives. ",
        error_caption="The sensor's error ‖e_s‖ = ‖x_s − x‖ is reset when it exceeds the "
        "threshold. The controller's error ‖e_c‖ = ‖x_c − x‖ may exceed the threshold while "
        "packets are lost; no process of the loop can measure it.",
        summary="Nothing is acknowledged.",
        reset="at every event",
    ),
    "ack": LoopProtocol(
        acknowledges=True,
        states_caption="x_c jumps to {known} when an update arrives, x_s when its acknowledgement arrives. ",
        error_caption="The sensor's error ‖e_s‖ = ‖x_s − x‖ is reset by acknowledgements; without "
        "one, the sensor transmits repeatedly. The controller's error is ‖e_c‖ = ‖x_c − x‖.",
        summary="**Updates are acknowledged.**",
        reset="when an update is acknowledged",
    ),
}


class Record(NamedTuple):
    """A row for the numeric record; ``noack.protocol.record_tables`` documents the tables."""

    table: str
    row: tuple[object, ...]


FAILED = "failed"  # level of the notice of a plant or controller that cannot continue


class Notice(NamedTuple):
    """A line for the run's log, such as a violated assumption."""

    t_ns: int
    level: str
    text: str
    loop: int | None = None
    """The number of the loop that it is about, in a run of several loops."""

    def line(self) -> dict[str, object]:
        """Return the fields; without the loop, if there is none."""
        line = self._asdict()
        return line if self.loop is not None else {k: line[k] for k in line if k != "loop"}


Output = Message | Record | Notice


class External:
    """A part of a machine that another program has: connected before the run.

    A replay cannot ask it again: there its answers are the recorded ones.
    """

    recorded: Vector | None = None
    """The next answer, in a replay."""

    def connect(self) -> None:
        """Connect, unless this was done; raise CallerError if that fails."""
