"""The life cycle of a process in a run, as one table of states and events.

The process and the coordinator each keep a :class:`LifeCycle` of it. An event that the table does
not allow raises an error that says who erred, as in h11.
"""

import time
from collections.abc import Mapping
from enum import Enum

from noack.core.errors import CallerError, PeerError

HORIZON = "horizon"  # reason of a process that has reached the end of the run
LAUNCHER_GONE = "the launcher ended early"  # reason of a process whose launcher has ended before it
LOST_AFTER_S = 8.0
"""A process is lost after four leases: a connection that a busy machine broke is back by then."""
LAUNCHED_LOST_S = 30.0
"""The same for a process that the launcher started: its exit is seen at once, so there is time."""


class Side(Enum):
    """The side that causes an event."""

    PROCESS = "the process"
    COORDINATOR = "the coordinator"


class State(Enum):
    """States of a process's life cycle."""

    REQUESTED = "admission requested"
    ADMITTED = "admitted"
    AT_BARRIER = "at the start barrier"
    RUNNING = "running"
    STOPPING = "stopping"
    UNREACHABLE = "unreachable"
    """Its liveliness token has vanished; its report or its connection may still come."""
    LOST = "lost"
    """Its token vanished and no report arrived. It may come back with its connection."""
    GONE = "gone"


class Event(Enum):
    """Events of a process's life cycle."""

    ADMIT = "is admitted"
    JOIN = "asks to join"
    START = "passes the start barrier"
    STOP = "is asked to stop"
    END = "ends"
    DISCONNECT = "loses its connection"
    RECONNECT = "is connected again"
    TIME_OUT = "does not come back in time"

    @property
    def side(self) -> Side:
        """The side that causes it; the coordinator causes what it observes itself."""
        return Side.PROCESS if self in (Event.JOIN, Event.END) else Side.COORDINATOR


_S, _E = State, Event
# fmt: off
TRANSITIONS: Mapping[State, Mapping[Event, State]] = {
    _S.REQUESTED: {_E.ADMIT: _S.ADMITTED, _E.STOP: _S.STOPPING, _E.END: _S.GONE,
                   _E.DISCONNECT: _S.REQUESTED, _E.RECONNECT: _S.REQUESTED},
    _S.ADMITTED: {_E.JOIN: _S.AT_BARRIER, _E.STOP: _S.STOPPING, _E.END: _S.GONE,
                  _E.DISCONNECT: _S.ADMITTED, _E.RECONNECT: _S.ADMITTED},
    # It asks again while it waits, and joins again when its connection is back.
    _S.AT_BARRIER: {_E.JOIN: _S.AT_BARRIER, _E.START: _S.RUNNING, _E.STOP: _S.STOPPING,
                    _E.END: _S.GONE, _E.DISCONNECT: _S.ADMITTED, _E.RECONNECT: _S.AT_BARRIER},
    # It joins again if the answer to its request was lost.
    _S.RUNNING: {_E.JOIN: _S.RUNNING, _E.STOP: _S.STOPPING, _E.END: _S.GONE,
                 _E.DISCONNECT: _S.UNREACHABLE, _E.RECONNECT: _S.RUNNING},
    _S.STOPPING: {_E.STOP: _S.STOPPING, _E.END: _S.GONE,
                  _E.DISCONNECT: _S.UNREACHABLE, _E.RECONNECT: _S.STOPPING},
    _S.UNREACHABLE: {_E.JOIN: _S.RUNNING, _E.STOP: _S.UNREACHABLE, _E.END: _S.GONE,
                     _E.DISCONNECT: _S.UNREACHABLE, _E.RECONNECT: _S.RUNNING,
                     _E.TIME_OUT: _S.LOST},
    _S.LOST: {_E.JOIN: _S.RUNNING, _E.STOP: _S.LOST, _E.END: _S.GONE,
              _E.DISCONNECT: _S.LOST, _E.RECONNECT: _S.RUNNING},
    _S.GONE: {_E.STOP: _S.GONE, _E.END: _S.GONE,
              _E.DISCONNECT: _S.GONE, _E.RECONNECT: _S.GONE},
}
# fmt: on
"""The next state, by state and event. What is missing is not allowed."""


class LifeCycle:
    """State of one process (``role``), as one side of the control plane knows it."""

    def __init__(self, role: str, side: Side) -> None:
        self.role = role
        self._side = side
        self.state = State.REQUESTED
        self.since_s = time.monotonic()
        """Reading of the monotonic clock when it entered the state."""
        self.reason: str | None = None
        """The reason why it stops or has ended; the first reason stays."""

    def apply(self, event: Event, reason: str | None = None) -> None:
        """Enter the next state; ``reason`` says why, for STOP and END.

        Raise CallerError if this side caused an event that the state does not allow, PeerError if
        the other side did.
        """
        state = TRANSITIONS[self.state].get(event)
        if state is None:
            error = CallerError if event.side is self._side else PeerError
            raise error(f"{self.role} {event.value}, which is wrong while it is {self.state.value}")
        if state is not self.state:
            self.state, self.since_s = state, time.monotonic()
        if self.reason is None:
            self.reason = reason

    @property
    def is_over(self) -> bool:
        """Whether it has ended or is lost."""
        return self.state in (State.LOST, State.GONE)

    def age_s(self) -> float:
        """Time in its state, in seconds of wall time."""
        return time.monotonic() - self.since_s
