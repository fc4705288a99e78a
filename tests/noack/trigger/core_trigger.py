"""The core's trigger, which a sensor applies at measurements, one call at a time."""

import numpy as np

from noack.core.core_library import CoreMemory, core, ffi
from noack.core.linear_systems import Vector
from noack.trigger.trigger_rule import TriggerDecision, TriggerRule, fill_rule, rule_rows


class CoreTrigger:
    """A policy that native/loop/trigger.c applies to n states."""

    def __init__(self, rule: TriggerRule, n: int) -> None:
        self._memory, self._n = CoreMemory(), n
        self._rule, self._state = ffi.new("noack_trigger_rule *"), ffi.new("noack_trigger_state *")
        fill_rule(self._rule, rule, n, self._memory)
        self._state.auxiliary = self._rule.initial
        self._scratch = self._memory.zeros(2 * n + rule_rows(rule))

    @property
    def latest_ns(self) -> int:
        """When the next event is due at the latest."""
        return int(self._state.latest_ns)

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event."""
        core.noack_trigger_start(*self._arguments(t_ns, x), self._scratch)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Decide whether a measurement is an event."""
        sides = np.zeros(2)
        event = core.noack_trigger_test(
            *self._arguments(t_ns, x), self._vector(e_s),
            ffi.cast("double *", sides.ctypes.data), self._scratch,
        )  # fmt: skip
        return TriggerDecision(bool(event), *sides.tolist())

    def _arguments(self, t_ns: int, x: Vector) -> tuple[object, ...]:
        return self._rule, self._state, self._n, t_ns, self._vector(x)

    def _vector(self, values: Vector) -> object:
        return ffi.new("double[]", values.tolist())
