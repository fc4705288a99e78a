"""The base of policies that combine a rule with an interval."""

from abc import abstractmethod
from typing import TYPE_CHECKING, Self

from pydantic import field_validator

from noack.settings.section import Rows
from noack.trigger.policy_settings import Interval, ModelMatrices, PolicySettings, nanoseconds
from noack.trigger.trigger_rule import TriggerRule, require_rule

if TYPE_CHECKING:
    AnyTrigger = PolicySettings  # noack.scenario.sections inserts the union of all policies


class CombinedSettings(PolicySettings):
    """Settings of a policy that combines a rule with an interval."""

    rule: "AnyTrigger"
    """The rule that is combined."""
    interval_s: Interval
    """Time since the last event."""

    @field_validator("rule")
    @classmethod
    def _check_rule(cls, rule: PolicySettings) -> PolicySettings:
        if rule.beyond_exact is not None:
            raise ValueError(f'"{rule.policy}" cannot be combined; let the class test the interval')
        return rule

    @abstractmethod
    def combined(self, rule: TriggerRule, interval_ns: int) -> TriggerRule:
        """Return a rule with the interval."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        rule = require_rule(self.rule.trigger_policy(model))
        return self.combined(rule, nanoseconds(self.interval_s))

    @property
    def weight(self) -> Rows | None:
        return self.rule.weight

    def at_origin(self, t_s: float) -> Self:
        return self.model_copy(update={"rule": self.rule.at_origin(t_s)})

    def check(self, n: int, why: str) -> None:
        try:
            self.rule.check(n, why)
        except ValueError as error:
            raise ValueError(str(error).replace("trigger.", "trigger.rule.", 1)) from None

    def check_period(self, measured_ns: int, key: str = "trigger") -> None:
        self.rule.check_period(measured_ns, f"{key}.rule")
