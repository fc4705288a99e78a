"""The liveliness tokens of a run's processes, as the recorder sees them."""

import math
import time
from collections.abc import Container, Mapping

import zenoh
from zenoh.handlers import RingChannel

from noack.protocol.topology import LOOP_ROLES
from noack.runtime.control_plane import ControlPlane
from noack.runtime.life_cycle import LAUNCHED_AWAY_S

_DISCOVERY_S = 5.0
"""By then a restarted recorder has received the tokens of all running processes."""


class ProcessTokens:
    """Which processes of the loop have been in the run, and which are gone.

    With ``restarted``, a process without a token ended before the recorder was restarted.
    """

    def __init__(self, plane: ControlPlane, *, restarted: bool) -> None:
        self._plane = plane
        self._restarted = restarted
        self._began_s = self._connected_s = time.monotonic()
        self._changes = plane.session.liveliness().declare_subscriber(
            plane.key("alive", "*", "*"), RingChannel(256), history=True
        )
        self._vanished_s: dict[str, dict[str, float]] = {role: {} for role in LOOP_ROLES}
        """When the token of each instance vanished, by role; infinity while it exists."""

    def update(self) -> None:
        """Take the changes that have arrived."""
        while (token := self._changes.try_recv()) is not None:
            role, instance = str(token.key_expr).split("/")[-2:]
            vanished = token.kind == zenoh.SampleKind.DELETE
            if role in self._vanished_s:
                self._vanished_s[role][instance] = time.monotonic() if vanished else math.inf

    def all_done(self, reported: Container[str], *, stopping: bool) -> bool:
        """Whether each process has reported its end, or is gone.

        A token may vanish because a busy machine broke a connection, also the recorder's own. The
        process is gone if it does not come back, or if one that replaced it has reported. A run
        that is ``stopping`` does not wait for it.
        """
        now_s = time.monotonic()
        if self._plane.coordinator_gone():
            self._connected_s = now_s
            return False
        away_s = 0.0 if stopping else LAUNCHED_AWAY_S
        discovered = self._restarted and now_s - self._began_s > _DISCOVERY_S

        def is_done(known: Mapping[str, float]) -> bool:
            if not known:
                return discovered
            waiting = [vanished for one, vanished in known.items() if one not in reported]
            if len(waiting) < len(known):
                return math.inf not in waiting
            return all(now_s - max(vanished, self._connected_s) > away_s for vanished in waiting)

        return all(map(is_done, self._vanished_s.values()))
