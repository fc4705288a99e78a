"""Requests of users to change the settings of a run: checked, given a time, and announced."""

from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from operator import itemgetter

from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from netem.core.settings_section import ReadTable, Table
from netem.impairments.target_loss import known_probabilities
from noack.runtime.control_messages import ChangeAnnouncement, ChangeReply, ChangeRequest, parse_message
from noack.runtime.control_plane import ControlPlane
from noack.scenario.overload import refuse_overload
from noack.scenario.parameter_changes import (
    ChangeSchedule,
    ParameterChange,
    changed,
    current_parameters,
    scheduled,
)
from noack.scenario.resolution import ResolvedRun, policy_of, resolve
from noack.scenario.run_sections import ScheduledChange
from noack.scenario.scenario_tables import MOST_CHANGES
from noack.trigger_policies.trigger_rule import TriggerRule

_CHANGE_DELAY_S = 0.2
"""Wall time from a change's announcement to its effect: processes check every 0.05 s."""
_MILLISECOND_NS = 1_000_000


class ChangeRequests:
    """The changes of a run."""

    def __init__(self, run: ResolvedRun, run_dir: str, plane: ControlPlane) -> None:
        self._scenario, self._run_dir = run.scenario, run_dir
        self._plane = plane
        self._schedule = ChangeSchedule[None](run.scenario)
        self._entries = {entry.name: ChangeSchedule[None](entry.scenario) for entry in run.entries}
        """The changes of the loops of each entry of [[loops]], by its name."""
        self.announced: tuple[ChangeAnnouncement, ...] = ()
        """Announcements of all changes so far."""
        for change in scheduled(run.scenario):
            self._add(change, 0, "in the scenario")

    def answer(self, request: bytes, clock: Callable[[], int], obstacle: str | None) -> ChangeReply:
        """Announce the requested change, unless there is an obstacle; return the parameters.

        Raise CallerError if the settings cannot be changed, or not now; PeerError if the message is
        not a change request.
        """
        settings = parse_message(ChangeRequest, request).settings
        from_s, now_ns, before = None, clock(), self._parameters()
        warnings: list[str] = []
        thresholds: dict[str, tuple[float, float]] = {}
        if settings:
            if obstacle is not None:
                raise CallerError(obstacle)
            # Before the time is chosen, as it may take long.
            are_new = [_is_new(settings, schedule, now_ns) for schedule in self._schedules]
            if any(are_new):
                violated_before = self._violations()
                rules_before = self._rules(settings)
                now_ns = clock()
                t_ns = self._announce(settings, now_ns)
                from_s = t_ns / NS_PER_S
                thresholds = {
                    name: (old, new)
                    for name, rule in self._rules(settings).items()
                    if (old := rules_before[name].shown_threshold(t_ns)) is not None
                    and (new := rule.shown_threshold(t_ns)) is not None
                }
                warnings = [line for line in self._violations() if line not in violated_before]
        loops = self._parameters()
        return ChangeReply(
            name=self._scenario.name,
            run_dir=self._run_dir,
            t_s=now_ns / NS_PER_S,
            from_s=from_s,
            runtime_parameters=current_parameters(self._schedule.last),
            loops=loops,
            changed_loops=tuple(name for name in loops if loops[name] != before[name]),
            warnings=tuple(warnings),
            thresholds=thresholds,
        )

    def _announce(self, settings: ReadTable, now_ns: int) -> int:
        """Announce a change; return the time from which it applies.

        Raise CallerError if it is not valid for this run, or comes too late.
        """
        if len(self.announced) >= MOST_CHANGES:
            raise CallerError(f"this run has had {MOST_CHANGES} changes, the maximum")
        delay_ns = int(_CHANGE_DELAY_S * NS_PER_S * self._scenario.speed)
        t_ns = -(-max(now_ns + delay_ns, 0) // _MILLISECOND_NS) * _MILLISECOND_NS
        if t_ns >= self._scenario.timing.horizon_ns:
            raise CallerError(f"the run ends at {self._scenario.horizon_s:g} s, before a change could apply")
        change = ParameterChange(len(self.announced), t_ns, settings)
        self._refuse_overload(change)
        requested_at = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._plane.announce_change(self._add(change, now_ns, requested_at))
        return t_ns

    def _refuse_overload(self, change: ParameterChange) -> None:
        """Raise CallerError if a link must overflow with a change, or with a later one after it."""
        timed = [(known.t_ns, known.settings) for known in self.announced] + [(change.t_ns, change.settings)]
        changes = tuple(
            ScheduledChange(at_s=t_ns / NS_PER_S, set=dict(settings))
            for t_ns, settings in sorted(timed, key=itemgetter(0))
        )
        try:
            refuse_overload(self._scenario.model_copy(update={"changes": changes}))
        except ValueError as error:
            raise CallerError(f"the change: {error}") from None

    def _violations(self) -> list[str]:
        """Return what gain and threshold violate, each as a line, with its loops if not all."""
        # Imports the theory, for which the start of a run does not wait.
        from noack.theory.certificates.assumptions import violated_by_gain_or_threshold

        violated: dict[str, list[str]] = {}
        with suppress(Exception):  # a failed analysis must not cost the run
            for name, schedule in self._entries.items():
                for line in violated_by_gain_or_threshold(resolve(schedule.last)):
                    violated.setdefault(line, []).append(name)
        return [
            line if len(names) == len(self._entries) else f"{', '.join(names)}: {line}"
            for line, names in violated.items()
        ]

    def _rules(self, settings: ReadTable) -> dict[str, TriggerRule]:
        """Return the trigger rules after all announced changes, if the settings are of the trigger."""
        if not any(key.startswith("trigger.") for key in settings):
            return {}
        rules = {name: _last_rule(schedule) for name, schedule in self._entries.items()}
        return {name: rule for name, rule in rules.items() if rule is not None}

    @property
    def _schedules(self) -> tuple[ChangeSchedule[None], ...]:
        return (self._schedule, *self._entries.values())

    def _parameters(self) -> dict[str, Table]:
        return {name: current_parameters(schedule.last) for name, schedule in self._entries.items()}

    def _add(self, change: ParameterChange, requested_ns: int, requested_at: str) -> ChangeAnnouncement:
        """Check and store a change; return its announcement.

        Raise CallerError if the change is not valid for this run.
        """
        for schedule in self._schedules:
            schedule.check(change, -1)
        for schedule in self._schedules:
            schedule.announce(table="", change=change, number=0, now_ns=0, reached_ns=-1)
        later = self._schedule.between(change.t_ns, self._scenario.timing.horizon_ns)
        announcement = ChangeAnnouncement(
            number=change.number,
            t_ns=change.t_ns,
            settings=dict(change.settings),
            requested_ns=requested_ns,
            requested_at=requested_at,
            target_losses=known_probabilities(*(changed_scenario.network.link for changed_scenario in later)),
        )
        self.announced += (announcement,)
        return announcement


def _last_rule(schedule: ChangeSchedule[None]) -> TriggerRule | None:
    """Return the trigger rule after all changes, each at its time; None if the trigger has none."""
    rule: TriggerRule | None = None
    for applied in schedule.all:
        policy = policy_of(resolve(applied.scenario))
        if not isinstance(policy, TriggerRule):
            return None
        rule = policy if rule is None else policy.continuing(rule, applied.since_ns)
    return rule


def _is_new(settings: ReadTable, schedule: ChangeSchedule[None], now_ns: int) -> bool:
    """Return whether settings differ from those in force, or another change is still to come.

    Raise CallerError if the settings are not valid.
    """
    before, after = (current_parameters(of) for of in (schedule.last, changed(schedule.last, settings)))
    return before != after or schedule.at(now_ns).scenario is not schedule.last
