"""Changes of the run's settings, as a process receives them during the run."""

from collections.abc import Iterable, Mapping
from typing import Any

from noack.config.parameter_changes import ParameterChange
from noack.core.errors import PeerError
from noack.runtime.control_messages import ChangeAnnouncement, parse_message
from noack.runtime.control_plane import ControlPlane


class ParameterUpdates:
    """Announced changes that the process has not taken yet, each once and in order.

    Args:
        plane: where the coordinator announces them.
    """

    def __init__(self, plane: ControlPlane) -> None:
        self._plane = plane
        self._waiting: list[dict[str, Any]] = []
        self._next_number = 0

    def extend(self, announcements: Iterable[dict[str, Any]]) -> None:
        """Add the changes that were announced before this process joined."""
        self._waiting.extend(announcements)

    def take(self, at_most: int | None = None) -> list[tuple[ParameterChange, Mapping[str, Any]]]:
        """Return waiting changes, each with its announcement.

        Args:
            at_most: how many; the others wait. None for all.
        """
        while (message := self._plane.next_change()) is not None:
            try:
                self._waiting.append(parse_message(ChangeAnnouncement, message))
            except PeerError:  # not from the coordinator
                continue
        taken: list[tuple[ParameterChange, Mapping[str, Any]]] = []
        while self._waiting and (at_most is None or len(taken) < at_most):
            one = self._waiting.pop(0)
            if one["number"] >= self._next_number:  # a late process receives some twice
                self._next_number = one["number"] + 1
                taken.append((ParameterChange(one["number"], one["t_ns"], one["settings"]), one))
        return taken
