"""Which failed processes a launcher restarts or waits for, and which failures end the run."""

import time
from collections.abc import Callable
from typing import NamedTuple

from cosim.live.child_processes import ChildProcesses, Failure
from cosim.live.coordinator import Coordinator
from noack.config.scenario import Scenario
from noack.core.errors import ExitStatus, MachineError
from noack.protocol.topology import PLANT, RECORDER

RESTART_BY_HAND_S = 60.0
"""How long a run waits for the restart of a process that was started by hand."""


class _Failed(NamedTuple):
    """A process that has failed and may be restarted."""

    failure: Failure
    until_s: float
    """Reading of the monotonic clock until which the run waits for the restart."""


class RestartPolicy:
    """Follows the failures of a run's processes."""

    def __init__(
        self,
        scenario: Scenario,
        coordinator: Coordinator,
        children: ChildProcesses,
        on_failure: Callable[[str, float, str | None], None],
        on_restart: Callable[[str, float], None],
    ) -> None:
        self._scenario = scenario
        self._coordinator = coordinator
        self._children = children
        self._on_failure = on_failure
        self._on_restart = on_restart
        self._failed: dict[str, _Failed] = {}

    def check(self) -> Failure | None:
        """Restart what may be restarted; return why the run must end, None if it need not."""
        exited = self._children.failures(self._coordinator.reported_failure)
        return self._check_restarts(exited) or self._check_failures(exited)

    def unfinished(self) -> Failure | None:
        """At the end of the run: a failure whose restart did not happen."""
        for failed in self._failed.values():
            status, why = failed.failure
            return status, f"{why}; not restarted before the end"
        return None

    def _check_restarts(self, exited: dict[str, Failure]) -> Failure | None:
        """Follow the processes that the run waits for."""
        for role, ((status, why), until_s) in list(self._failed.items()):
            if self._coordinator.running_generation(role) is not None:
                del self._failed[role]
                self._on_restart(role, self._t_s())
            elif role in exited:
                return exited[role][0], f"{why}; restarted, {exited[role][1]}"
            elif time.monotonic() > until_s:
                return status, f"{why}; not restarted within {self._restart_within_s(role):g} s"
        return None

    def _check_failures(self, exited: dict[str, Failure]) -> Failure | None:
        """Restart, or wait for, each process that has failed since the last look."""
        for role, (status, why) in self._failures(exited).items():
            within_s = self._restart_within_s(role)
            started = self._coordinator.epoch_ns is not None
            if not started or self._is_past_horizon() or role == PLANT or not within_s:
                return status, why
            if self._children.has_reported(role):  # a restarted process would fail alike
                return status, why
            self._failed[role] = _Failed((status, why), time.monotonic() + within_s)
            launched = role in self._children
            self._coordinator.allow_restart(role, why, dead=self._children.is_dead(role))
            self._on_failure(why, self._t_s(), None if launched else role)
            if launched:
                try:
                    self._children.restart(role)
                except MachineError as error:
                    return status, f"{why}; {error}"
        return None

    def _failures(self, exited: dict[str, Failure]) -> dict[str, Failure]:
        """Failures that are not being waited for, by role."""
        running = self._children.running()
        failures = {
            role: (ExitStatus.FAILED, why)
            for role, why in self._coordinator.failures().items()
            # The exit status of a launched process explains more than its report.
            if not (role in running and self._coordinator.is_exiting(role))
        }
        if self._is_past_horizon() and RECORDER in running:
            failures.pop(RECORDER, None)  # sorting a long record, it may not respond
        return {role: one for role, one in (failures | exited).items() if role not in self._failed}

    def _is_past_horizon(self) -> bool:
        return self._coordinator.now_ns() >= self._scenario.timing.horizon_ns

    def _t_s(self) -> float:
        return self._coordinator.now_ns() * 1e-9

    def _restart_within_s(self, role: str) -> float:
        given_s = self._scenario.recovery.rejoin_within_s
        if given_s is None:
            return 0.0 if role in self._children else RESTART_BY_HAND_S
        return given_s
