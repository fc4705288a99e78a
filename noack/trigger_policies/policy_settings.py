"""The settings that every trigger policy has, and those of policies of the same form.

A policy is one file of this folder. The file holds a subclass of :class:`PolicySettings` with a
field ``policy``, and the behaviour that the settings describe;
:mod:`noack.scenario.sections` finds it there.
"""

import json
import warnings
from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple, Self, TypeAlias, get_args

import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from netem.core.errors import CallerError
from netem.core.periods import Period, whole_ns
from netem.core.settings_section import ReadTable, ScenarioSection
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.settings.values import MatrixRows, require_shape, rows_of
from noack.trigger_policies.trigger_rule import Policy, TriggerRule, require_rule

Size = Annotated[FiniteFloat, Field(ge=1e-15, le=1e15)]
Ratio = Annotated[FiniteFloat, Field(gt=0, le=1e9)]
_SOLVED = 1e-6
"""Largest residual of AᵀP + PA = −Q for a stated P, as a share of its largest term."""
IntervalS = Annotated[FiniteFloat, Field(ge=1e-9, le=1e7)]

if TYPE_CHECKING:
    AnyTrigger: TypeAlias = "PolicySettings"  # noack.scenario.sections inserts the union of all policies


class ModelMatrices(NamedTuple):
    """The model and the gain that sensor and controller know."""

    A: Matrix  # Â, (n, n)
    B: Matrix  # B̂, (n, m)
    K: Matrix  # Gain, (m, n)


class PolicySettings(ScenarioSection):
    """Settings of a trigger policy."""

    example_keys: ClassVar[ReadTable | None] = None
    """Keys of the example, which :meth:`example` returns."""
    at_start_only: ClassVar[tuple[str, ...]] = ()
    """Keys that describe the start of a run and cannot change later."""
    is_rule: ClassVar[bool] = True
    """Whether the policy is a trigger rule; else it is code."""

    policy: str

    if TYPE_CHECKING:

        @property
        def weight(self) -> MatrixRows | None:
            """W of the norm ‖v‖_W; None is the identity."""
            return None

    @classmethod
    def example(cls, n: int) -> Self | None:
        """Return settings for n states of size 1, for tests and benchmarks, if there are any."""
        if cls.example_keys is None:
            return None
        (policy,) = get_args(cls.model_fields["policy"].annotation)
        return cls.model_validate_json(json.dumps({"policy": policy, **cls.example_keys}))

    @abstractmethod
    def trigger_policy(self, model: ModelMatrices) -> Policy:
        """Return what these settings describe: a rule as data, or code.

        Raises:
            CallerError: the policy cannot be used with this model.
        """

    def resolved(self, model: ModelMatrices) -> Self:
        """Return settings with all numbers that the trigger computes from the model.

        Raises:
            CallerError: the policy cannot be used with this model.
        """
        return self

    @property
    @abstractmethod
    def description(self) -> str:
        """The condition under which the sensor transmits, in one line."""

    def check(self, n: int, why: str) -> None:
        """Require matrices of the right shapes for n states.

        Raises:
            ValueError: a matrix has another shape, or is not allowed.
        """

    def intervals(self) -> Mapping[str, tuple[str, float]]:
        """Return the times between events that it names, by key: what they are in words, and seconds.

        Events are at measurements: other times are rounded up to these.
        """
        return {}

    def check_period(self, measured: Period, key: str = "trigger") -> None:
        """Require that the policy's own sampling period fits the time between measurements.

        Raises:
            ValueError: the period is not a whole number of that time.
        """


class WeightedSettings(PolicySettings):
    """Settings of a policy with a norm of its own."""

    weight: MatrixRows | None = None
    """W of the norm ‖v‖_W = ‖W v‖₂ by rows, n x n, invertible; the identity unless given."""

    @property
    def weight_matrix(self) -> Matrix | None:
        """W, shape (n, n); None is the identity."""
        return None if self.weight is None else np.array(self.weight)

    def check(self, n: int, why: str) -> None:
        """Require an invertible W of shape (n, n)."""
        require_shape(self.weight, "trigger.weight", (n, n), why)
        if self.weight is not None and np.linalg.matrix_rank(np.array(self.weight)) < n:
            raise ValueError("trigger.weight: W must be invertible, this one is singular")


class LyapunovFunctionSettings(WeightedSettings):
    """Settings of a policy that uses a Lyapunov function of the model's closed loop."""

    Q: MatrixRows | None = None
    """Q by rows, n x n, symmetric and positive definite; the identity unless given. P solves
    AᵀP + PA = −Q of the closed loop A = Â + B̂K."""
    P: MatrixRows | None = None
    """P by rows, n x n. A resolved scenario has it. It follows from Q, so leave it out."""

    def check(self, n: int, why: str) -> None:
        """Require matrices of the right shapes, and a positive definite Q."""
        super().check(n, why)
        require_shape(self.Q, "trigger.Q", (n, n), why)
        if self.Q is not None:
            Q = np.array(self.Q)
            if not np.allclose(Q, Q.T, rtol=1e-12, atol=0.0) or np.linalg.eigvalsh(Q)[0] <= 0:
                raise ValueError("trigger.Q: must be symmetric and positive definite")
        require_shape(self.P, "trigger.P", (n, n), why)
        if self.P is not None and not np.array_equal(np.array(self.P), np.array(self.P).T):
            raise ValueError("trigger.P: must be symmetric")

    def resolved(self, model: ModelMatrices) -> Self:
        """Return settings with P."""
        return self.model_copy(update={"P": rows_of(self.lyapunov_function(model)[0])})

    def lyapunov_function(self, model: ModelMatrices) -> tuple[Matrix, Matrix]:
        """Return P and Q with AᵀP + PA = −Q of the model's closed loop, each (n, n).

        Raises:
            CallerError: the closed loop is not stable, or a stated P does not belong to it.
        """
        A, Q = model.A + model.B @ model.K, np.eye(len(model.A)) if self.Q is None else np.array(self.Q)
        if self.P is None:
            return self._solution(A, Q), Q
        P = np.array(self.P)
        terms = np.abs(A.T) @ np.abs(P) + np.abs(P) @ np.abs(A) + np.abs(Q)
        if (np.abs(A.T @ P + P @ A + Q) > _SOLVED * terms.max()).any():
            raise CallerError("trigger.P: AᵀP + PA is not −Q for A = Â + B̂K; leave P out")
        return P, Q

    @staticmethod
    def _solution(A: Matrix, Q: Matrix) -> Matrix:
        from scipy.linalg import solve_continuous_lyapunov  # slow to import

        if spectral_abscissa(A) >= 0:
            raise CallerError("trigger.policy: this one needs a Lyapunov function, but Â + B̂K is not stable")
        with warnings.catch_warnings(action="ignore"):  # of an inaccurate P, which is checked
            P = np.asarray(solve_continuous_lyapunov(A.T, -Q), dtype=np.float64)
        P = (P + P.T) / 2
        if not np.isfinite(P).all() or np.linalg.eigvalsh(P)[0] <= 0:
            raise CallerError(
                "trigger.policy: this one needs a Lyapunov function, and none is found within "
                "rounding: modes of Â + B̂K differ too much"
            )
        return P


class CombinedSettings(PolicySettings):
    """Settings of a policy that combines a rule with an interval."""

    rule: "AnyTrigger"
    """The rule that is combined."""
    interval_s: IntervalS
    """Time since the last event."""

    @field_validator("rule")
    @classmethod
    def _check_rule(cls, rule: PolicySettings) -> PolicySettings:
        if not rule.is_rule:
            raise ValueError(f'"{rule.policy}" cannot be combined; let the class test the interval')
        return rule

    @abstractmethod
    def combined(self, rule: TriggerRule, interval_ns: int) -> TriggerRule:
        """Return a rule with the interval."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        rule = require_rule(self.rule.trigger_policy(model))
        return self.combined(rule, whole_ns(self.interval_s))

    def resolved(self, model: ModelMatrices) -> Self:
        return self.model_copy(update={"rule": self.rule.resolved(model)})

    @property
    def weight(self) -> MatrixRows | None:
        return self.rule.weight

    def check(self, n: int, why: str) -> None:
        try:
            self.rule.check(n, why)
        except ValueError as error:
            raise ValueError(str(error).replace("trigger.", "trigger.rule.", 1)) from None

    def intervals(self) -> Mapping[str, tuple[str, float]]:
        of_rule = {f"rule.{key}": interval for key, interval in self.rule.intervals().items()}
        return {"interval_s": (f"the {self.policy} ends at a measurement, after", self.interval_s), **of_rule}

    def check_period(self, measured: Period, key: str = "trigger") -> None:
        self.rule.check_period(measured, f"{key}.rule")
