"""Compares the losses of received updates with the guarantee that was in force when they occurred."""

from collections.abc import Sequence

from noack.guarantee.loss_guarantee import LongestBurst, LossGuarantee, LossHistory, LossRule
from noack.protocol.roles import Notice
from noack.scenario.parameter_changes import ChangeSchedule


class LossCheck:
    """The losses of a flow's updates.

    After a change of the guarantee, the rules other than the limit of consecutive losses begin
    anew, with the first update after one that was sent under the new guarantee.

    Args:
        guarantee: more losses violate the assumption.
        schedule: the announced changes of settings; None if there are none.
        known_start: whether the controller needs no first update.
    """

    def __init__(
        self,
        guarantee: LossGuarantee,
        schedule: ChangeSchedule[object] | None,
        *,
        known_start: bool,
    ) -> None:
        self._schedule = schedule
        self._known_start = known_start
        self._guarantee = guarantee
        self._since_ns = 0
        self._further = _further(guarantee)
        self._history = LossHistory(self._further)
        self._newest_ns = 0

    def reach(self, t_ns: int) -> None:
        """Use the guarantee that is in force at a time of the controller's model."""
        if self._schedule is not None:
            now = self._schedule.at(t_ns)
            self._change(now.scenario.network.guarantee, now.since_ns)

    @property
    def counts_every_update(self) -> bool:
        """Whether updates without a loss before them matter, too."""
        return bool(self._further) or (self._schedule is not None and self._schedule.has_changes)

    def _change(self, guarantee: LossGuarantee, since_ns: int) -> None:
        """Use another guarantee for what is sent from ``since_ns`` on."""
        if guarantee != self._guarantee:
            self._guarantee, self._since_ns = guarantee, since_ns
            self._further = _further(guarantee)
            self._history = LossHistory(self._further)

    def add(self, sequence: int, newest: int, losses: int, event_ns: int, now_ns: int) -> Sequence[Notice]:
        """Add an update that follows ``losses`` losses; return the violations.

        ``newest`` is the number of the update before; −1 if there is none.
        """
        newest_ns, self._newest_ns = self._newest_ns, event_ns
        violation = self._consecutive(sequence, losses, newest_ns, max(now_ns, event_ns))
        if not violation and newest == -1 and losses > 0 and not self._known_start:
            violation = f"no delivered t_0: {losses} updates were lost before the first delivery"
        texts = [violation] if violation else []
        if newest_ns >= self._since_ns:
            texts += self._windows(sequence, losses)
        return [Notice(event_ns, "violation", text) for text in texts]

    def _consecutive(self, sequence: int, losses: int, newest_ns: int, now_ns: int) -> str:
        """Compare with the largest limit in force since the update before."""
        allowed = _longest_burst(self._guarantee)
        if losses > allowed and self._schedule is not None:
            scenarios = self._schedule.between(newest_ns, now_ns)
            allowed = max(_longest_burst(scenario.network.guarantee) for scenario in scenarios)
        if losses <= allowed:
            return ""
        return (
            f"MANSD violated: {losses} consecutive losses before update {sequence}, at most {allowed} assumed"
        )

    def _windows(self, sequence: int, losses: int) -> list[str]:
        """Follow the other rules; return the violations, of each rule the largest."""
        if not self._further:
            return []
        worst: dict[LossRule, int] = {}
        # After a whole window of losses, one more changes nothing.
        for lost in (True,) * min(losses, self._longest) + (False,):
            for rule, value in self._history.add(lost):
                if lost:
                    worst[rule] = max(worst.get(rule, 0), value)
        return [
            f"{rule.name} violated: {rule.violation(value)}, before update {sequence}"
            for rule, value in worst.items()
        ]

    @property
    def _longest(self) -> int:
        return max(window.packets for window in self._guarantee.windows)


def _further(guarantee: LossGuarantee) -> tuple[LossRule, ...]:
    return tuple(rule for rule in guarantee.rules if not isinstance(rule, LongestBurst))


def _longest_burst(guarantee: LossGuarantee) -> int:
    """The limit of consecutive losses that is set, not what follows from other rules."""
    return min(rule.limit for rule in guarantee.rules if isinstance(rule, LongestBurst))
