"""A user's trigger: a class in a Python file or in an installed package.

The class decides measurement by measurement, in the sensor's process. It is code, not a trigger
rule: exact simulation and the theory do not cover it.
"""

from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from netem.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.settings.user_files import ClassSettings, UserCode, new_instance, read_only, user_code
from noack.trigger_policies.policy_settings import ModelMatrices, WeightedSettings
from noack.trigger_policies.trigger_rule import CodedPolicy, TriggerDecision

_NO_RULE = (
    'trigger.policy: needs a policy that is a rule; this scenario has "python", a class that '
    "decides at measurements only"
)


class PythonTriggerSettings(ClassSettings, WeightedSettings):
    """A user's class, from an installed package or a file.

    Its code runs in the sensor's process; docs/scenarios.md lists the methods that it must have.
    """

    group: ClassVar = "noack.triggers"
    is_rule: ClassVar = False

    policy: Literal["python"]

    def trigger_policy(self, model: ModelMatrices) -> CodedPolicy:
        return CodedPolicy(self.weight_matrix, partial(PythonTrigger, self), _NO_RULE)

    @property
    def description(self) -> str:
        file = "" if self.file is None else f" of {Path(self.file).name}"
        return f"the class {self.name}{file} decides"


class PythonTrigger:
    """An object of a user's class that decides at measurements.

    The class has ``start(t_s, x)``, called at the start and after each event, and
    ``test(t_s, x, e_s)``. ``test`` returns whether to transmit, or a pair of numbers: then the
    sensor transmits if the first exceeds the second, and both are recorded.

    Raises:
        CallerError: the class does not exist, raises, or lacks a method.
    """

    def __init__(self, settings: PythonTriggerSettings) -> None:
        self._user_code = partial(user_code, settings, "trigger", CallerError)
        with self._user_code():
            self._object, _ = new_instance(settings, "trigger")
            for method in ("start", "test"):
                if not callable(getattr(self._object, method, None)):
                    raise TypeError(f"it has no method {method}")

    def start(self, t_ns: int, x: Vector) -> None:
        with self._user_code():
            self._object.start(t_ns * 1e-9, read_only(x))

    def restart(self, t_ns: int, x: Vector) -> None:
        self.start(t_ns, x)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Decide whether a measurement is an event.

        Raises:
            CallerError: the class raises, or returns something else than a decision.
        """
        with self._user_code():
            left, right = _sides(self._object.test(t_ns * 1e-9, read_only(x), read_only(e_s)))
            # In a run that diverges, x or e_s may be infinite, and what is computed from them NaN.
            if np.isnan([left, right]).any() and np.isfinite([x, e_s]).all():
                raise ValueError("test(t_s, x, e_s) returned NaN")
        return TriggerDecision(left > right, left, right)


def _sides(decision: UserCode) -> tuple[float, float]:
    """Return a result of ``test`` as two numbers to compare."""
    if isinstance(decision, bool | np.bool_):
        return float(decision), 0.0
    sides = np.array(decision)
    if sides.shape != (2,) or sides.dtype.kind not in "biuf":
        raise TypeError("test(t_s, x, e_s) must return True, False or a pair of numbers")
    return float(sides[0]), float(sides[1])
