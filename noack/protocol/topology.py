"""Topology of the loop (see ARCHITECTURE.md): which process sends which flow to which.

The acknowledgement baseline (``network.protocol = "ack"``) adds a reverse path over the same
sockets: controller, netem, sensor.
"""

from collections.abc import Mapping
from typing import NamedTuple

from noack.protocol.wire_format import Flow


class MessageRoute(NamedTuple):
    """Received flow, sent flow and receiver of a process."""

    receives: Flow
    sends: Flow
    to: str


ROUTES: Mapping[str, MessageRoute] = {
    "plant": MessageRoute(Flow.ACTUATION, Flow.MEASUREMENT, "sensor"),
    "sensor": MessageRoute(Flow.MEASUREMENT, Flow.UPDATE, "netem"),
    "netem": MessageRoute(Flow.UPDATE, Flow.UPDATE, "controller"),
    "controller": MessageRoute(Flow.UPDATE, Flow.ACTUATION, "plant"),
}

SENDER: Mapping[str, str] = {leg.to: role for role, leg in ROUTES.items()}
"""The peer from which each process receives."""

LOOP_ROLES = tuple(ROUTES)
PLANT = "plant"
CHANGEABLE = ("sensor", "netem", "controller")  # processes with runtime parameters
RECORDER = "recorder"
COORDINATOR = "coordinator"
ROLES = (*LOOP_ROLES, RECORDER)
