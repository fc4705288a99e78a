"""The picture: who sends which flow to whom. Nothing else is ever sent in the loop.

plant ──measurement──▶ sensor ──update──▶ netem ──what survives──▶ controller
▲                                                                    │
└────────────────────────────── actuation ───────────────────────────┘

The acknowledgement baseline (``network.protocol = "ack"``) has one way more, over the same sockets:

sensor ◀──what survives── netem ◀──acknowledgement── controller
"""

from collections.abc import Mapping
from typing import NamedTuple

from noack.protocol.wire_format import Flow


class MessageRoute(NamedTuple):
    """What a process receives, and what it sends to whom."""

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
"""From whom each process receives."""

LOOP_ROLES = tuple(ROUTES)
PLANT = "plant"
CHANGEABLE = ("sensor", "netem", "controller")
"""Processes whose settings may change during a run."""
RECORDER = "recorder"
COORDINATOR = "coordinator"
ROLES = (*LOOP_ROLES, RECORDER)
