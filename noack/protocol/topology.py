"""Topology of the loop (see ARCHITECTURE.md): which process sends which flow to which.

Updates cross the network between sensor and controller. Acknowledgements of the baseline, or
actuations, may cross it, too (:mod:`noack.config.sections`).
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

from noack.protocol.wire_format import Flow


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
"""What crosses the network in the paper's loop."""


def receiver_of(role: str, flow: Flow, network: Collection[Flow] = PAPER) -> str:
    """To whom a process sends a flow; ``network`` has the flows that cross the network."""
    return "netem" if flow in network and role != "netem" else ENDS[flow].receiver


def sender_to(role: str, flow: Flow, network: Collection[Flow] = PAPER) -> str:
    """From whom a process receives a flow; ``network`` has the flows that cross the network."""
    return "netem" if flow in network and role != "netem" else ENDS[flow].sender


LOOP_ROLES = tuple(RECEIVES)
PLANT = "plant"
WITH_DEADLINES = ("plant", "controller")  # processes that act at nominal times
CHANGEABLE = ("sensor", "netem", "controller")  # processes with runtime parameters
RECORDER = "recorder"
COORDINATOR = "coordinator"
ROLES = (*LOOP_ROLES, RECORDER)
