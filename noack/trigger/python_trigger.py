"""A trigger of the user's own: a class in a Python file or in an installed package.

The class decides measurement by measurement, in the sensor's process. It is code, not a trigger
rule: exact simulation, the batch engine and the theory do not cover it.
"""

from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.settings.user_class import ClassSettings, failure_text, new_instance, read_only
from noack.trigger.policy_settings import ModelMatrices, WeightedSettings
from noack.trigger.trigger_policy import CodedPolicy, Policy, TriggerDecision

_PLACE = "trigger"
_BEYOND_EXACT = (
    'trigger.policy: needs a policy that is a rule; this scenario has "python", a class that '
    "decides at measurements only"
)


class PythonTriggerSettings(ClassSettings, WeightedSettings):
    """A class of the user's own, from an installed package or from a file.

    Its code runs in the sensor's process; docs/scenarios.md says what the class must offer.
    """

    group: ClassVar = "noack.triggers"

    policy: Literal["python"]
    """The event-triggering policy."""

    @classmethod
    def example(cls, n: int) -> None:
        """None: the class is the user's."""
        return

    def trigger_policy(self, model: ModelMatrices) -> "PythonPolicy":
        """Return the behaviour."""
        return PythonPolicy(self)

    @property
    def description(self) -> str:
        """The class."""
        file = "" if self.file is None else f" of {Path(self.file).name}"
        return f"the class {self.name}{file} decides so"

    @property
    def beyond_exact(self) -> str:
        """The class is code."""
        return _BEYOND_EXACT


class PythonPolicy(CodedPolicy):
    """The policy that a user's class is.

    Args:
        settings: of a loaded scenario.
    """

    def __init__(self, settings: PythonTriggerSettings) -> None:
        self._settings = settings

    @property
    def weight(self) -> Matrix | None:
        """W of the norm in which errors are shown."""
        return self._settings.weight_matrix

    def new_trigger(self) -> "PythonTrigger":
        """Return a trigger with an object of the class."""
        return PythonTrigger(self._settings)


class PythonTrigger:
    """An object of a user's class that decides at measurements.

    The class has ``start(t_s, x)``, called at the start and after each event, and
    ``test(t_s, x, e_s)``. ``test`` returns whether to transmit, or a pair of numbers: then the
    sensor transmits if the first exceeds the second, and both are recorded.

    Args:
        settings: of a loaded scenario.

    Raises:
        CallerError: the class does not exist, raises, or lacks a method.
    """

    def __init__(self, settings: PythonTriggerSettings) -> None:
        self._settings = settings
        try:
            self._object, _ = new_instance(settings, _PLACE)
            for method in ("start", "test"):
                if not callable(getattr(self._object, method, None)):
                    raise TypeError(f"it has no method {method}")
        except CallerError:
            raise
        except (Exception, SystemExit) as error:
            raise self._failure(error) from None

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event, at a state of shape (n,)."""
        try:
            self._object.start(t_ns * 1e-9, read_only(x))
        except (Exception, SystemExit) as error:
            raise self._failure(error) from None

    def restart(self, t_ns: int, x: Vector) -> None:
        """Begin after a past event, known only now to have reset the model."""
        self.start(t_ns, x)

    def change(self, policy: Policy) -> None:
        """Continue: the settings of a class do not change during a run."""

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Decide whether a measurement is an event.

        Args:
            t_ns: its time.
            x: the measured state, shape (n,).
            e_s: x_s − x, shape (n,).

        Raises:
            CallerError: the class raises, or returns something else than a decision.
        """
        try:
            left, right = _sides(self._object.test(t_ns * 1e-9, read_only(x), read_only(e_s)))
        except (Exception, SystemExit) as error:
            raise self._failure(error) from None
        return TriggerDecision(left > right, left, right)

    def _failure(self, error: BaseException) -> CallerError:
        return CallerError(failure_text(self._settings, _PLACE, error))


def _sides(decision: Any) -> tuple[float, float]:
    """What ``test`` returned, as two numbers to compare."""
    if isinstance(decision, bool | np.bool_):
        return float(decision), 0.0
    sides = np.array(decision)
    if sides.shape != (2,) or sides.dtype.kind not in "biuf":
        raise TypeError("test(t_s, x, e_s) must return True, False or a pair of numbers")
    return float(sides[0]), float(sides[1])
