"""The base of policies that combine a rule with an interval."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

from pydantic import field_validator

from noack.core.linear_systems import Matrix
from noack.settings.section import Rows
from noack.trigger.policy_settings import Interval, PolicySettings
from noack.trigger.trigger_rule import Policy

if TYPE_CHECKING:
    AnyTrigger = PolicySettings  # noack.config.sections inserts the union of all policies


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

    @property
    def weight(self) -> Rows | None:
        return self.rule.weight

    @property
    def threshold_decay_per_s(self) -> float:
        return self.rule.threshold_decay_per_s

    def at_origin(self, t_s: float) -> Self:
        return self.model_copy(update={"rule": self.rule.at_origin(t_s)})

    @property
    def largest_threshold(self) -> float:
        return self.rule.largest_threshold

    @property
    def least_threshold(self) -> float | None:
        return self.rule.least_threshold

    def check(self, n: int, why: str) -> None:
        try:
            self.rule.check(n, why)
        except ValueError as error:
            raise ValueError(str(error).replace("trigger.", "trigger.rule.", 1)) from None

    def check_period(self, measured_ns: int, key: str = "trigger") -> None:
        self.rule.check_period(measured_ns, f"{key}.rule")


@dataclass(frozen=True)
class CombinedTrigger:
    """A rule with an interval."""

    rule: Policy
    interval_ns: int

    @property
    def weight(self) -> Matrix | None:
        return self.rule.weight

    @property
    def initial_dynamic_variable(self) -> float:
        return self.rule.initial_dynamic_variable
