"""Requests to change the runtime parameters of a run: checked, given a time, announced."""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from noack.config.parameter_changes import (
    ChangeSchedule,
    ParameterChange,
    changed,
    current_parameters,
    scheduled,
)
from noack.config.scenario import loop_scenario
from noack.config.scenario_tables import MOST_CHANGES
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.impairments.loss_prediction import found_probabilities
from noack.runtime.control_messages import ChangeRequest, parse_message
from noack.runtime.control_plane import ControlPlane
from noack.runtime.join_ticket import Ticket

_CHANGE_DELAY_S = 0.2
"""Wall time from a change's announcement to its effect: processes look every 0.05 s."""
_MILLISECOND_NS = 1_000_000


class ChangeRequests:
    """The changes of a run."""

    def __init__(self, ticket: Ticket, plane: ControlPlane) -> None:
        self._scenario, self._run_dir = ticket.scenario, ticket.run_dir
        self._plane = plane
        loops = ticket.scenario.loops or ()
        self._schedule, *self._of_loops = (
            ChangeSchedule(one)
            for one in (ticket.scenario, *(loop_scenario(ticket.scenario, one) for one in loops))
        )
        self.announced: list[dict[str, Any]] = []
        """Announcements of all changes so far."""
        for change in scheduled(ticket.scenario):
            self._add(change, 0, "in the scenario")

    def answer(
        self, request: bytes, clock: Callable[[], int], obstacle: str | None
    ) -> dict[str, Any]:
        """Announce the requested change, unless there is an obstacle; return the parameters.

        Raises:
            CallerError: the settings cannot be changed, or not now.
            PeerError: the message is not a change request.
        """
        settings = parse_message(ChangeRequest, request).get("settings", {})
        from_s, now_ns = None, clock()
        if settings:
            if obstacle is not None:
                raise CallerError(obstacle)
            if len(self.announced) >= MOST_CHANGES:
                raise CallerError(f"this run has had {MOST_CHANGES} changes, the maximum")
            # Before the time is chosen, as it may take long.
            for one in (self._schedule, *self._of_loops):
                changed(one.last, settings)
            now_ns = clock()
            delay_ns = int(_CHANGE_DELAY_S * NS_PER_S * self._scenario.speed)
            t_ns = -(-max(now_ns + delay_ns, 0) // _MILLISECOND_NS) * _MILLISECOND_NS
            if t_ns >= self._scenario.timing.horizon_ns:
                raise CallerError(
                    f"the run ends at {self._scenario.horizon_s:g} s, before a change could apply"
                )
            change = ParameterChange(len(self.announced), t_ns, settings)
            requested_at = datetime.now(UTC).isoformat(timespec="milliseconds")
            self._plane.announce_change(self._add(change, now_ns, requested_at))
            from_s = t_ns / NS_PER_S
        return {
            "name": self._scenario.name,
            "run_dir": self._run_dir,
            "t_s": now_ns / NS_PER_S,
            "from_s": from_s,
            "runtime_parameters": current_parameters(self._schedule.last),
        }

    def _add(self, change: ParameterChange, requested_ns: int, requested_at: str) -> dict[str, Any]:
        """Check and store a change; return its announcement.

        Raises:
            CallerError: the change is not valid for this run.
        """
        for one in (self._schedule, *self._of_loops):
            one.announce("", change, 0, 0, -1)
        announcement = {
            "number": change.number,
            "t_ns": change.t_ns,
            "settings": dict(change.settings),
            "requested_ns": requested_ns,
            "requested_at": requested_at,
            "kept_losses": found_probabilities(
                *(
                    one.network.link
                    for one in self._schedule.between(change.t_ns, self._scenario.timing.horizon_ns)
                )
            ),
        }
        self.announced.append(announcement)
        return announcement
