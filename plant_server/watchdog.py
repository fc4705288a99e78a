"""The plant's watchdog: the input that is applied when no actuation has arrived for too long.

At t_k the newest actuation is too old if t_k − t > timeout. Here t is the time of the model state
x_c from which the actuation was computed; before the first actuation, t = 0. Until then its inputs
are applied. The policy then determines the input (native/loop/plant.c):

* ``hold``: the last input of the newest actuation;
* ``zero``: 0;
* ``model``: a predictive actuator. It applies the controller's input for the case that no update
  has arrived since t: u + K(x̂ − x_c) with x̂ = e^{H(t_k − t)} x_c. For this an actuation carries
  [u; x_c]. Since u = K x_c, the input equals K x̂. Before the controller's first update, x_c = 0
  and u is the safe input, so the input is the safe input. With zero-order hold (H = 0) it is u.
"""

from dataclasses import dataclass
from typing import Any

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.core_library import core
from noack.core.core_memory import CoreMemory
from noack.core.linear_systems import Matrix
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import NO_SEQUENCE

NEVER_NS = 2**63 - 1
"""A timeout that no run reaches."""
INPUT_NAMES = {"hold": "held", "zero": "0", "model": "the model's"}
"""The input that each policy applies, in words."""
_POLICIES = {
    "hold": core.NOACK_HOLD, "zero": core.NOACK_ZERO, "model": core.NOACK_PREDICT,
}  # fmt: skip


@dataclass(frozen=True)
class Watchdog:
    """Settings of a plant's watchdog."""

    timeout_ns: int = NEVER_NS
    """The policy chooses the input if the newest actuation is older."""
    policy: str = "hold"
    notice_ns: int = 0
    """Age from which a notice reports it; at least the timeout."""
    H: Matrix | None = None
    """The controller's model, (n, n), of policy ``model``."""
    K: Matrix | None = None
    """Its gain, (m, n)."""

    @property
    def is_predictive(self) -> bool:
        """Whether actuations carry the controller's model state."""
        return self.policy == "model"

    def fill(self, plant: Any, memory: CoreMemory, period_ns: int) -> None:
        """Fill the watchdog of a ``noack_plant`` with this step."""
        memory.fill(plant, {
            "watchdog": _POLICIES[self.policy], "timeout_ns": self.timeout_ns,
            "notice_ns": max(self.notice_ns, self.timeout_ns),
            "carries_model": self.is_predictive, "K": self.K,
        })  # fmt: skip
        if self.H is not None:
            memory.set_model(plant.fallback, memory.transitions(self.H, (period_ns,)))


def watchdog_of(resolved: Scenario) -> Watchdog:
    """Return the watchdog of a resolved scenario's plant."""
    timing, policy, loop = resolved.timing, resolved.plant.watchdog.policy, loop_of(resolved)
    model = (loop.H, loop.K) if policy == "model" else ()
    return Watchdog(timing.actuation_timeout_ns, policy, timing.missing_actuation_ns, *model)


def too_old(t_ns: Any, newest_ns: Any, timeout_ns: int) -> Any:
    """Whether an actuation of time ``newest_ns`` is too old at ``t_ns``; also of arrays."""
    return t_ns - newest_ns > timeout_ns


def watchdog_notice(watchdog: Watchdog, note: Any) -> Notice:
    """Return the line for the log of a ``noack_note``."""
    t_ns, since_ns, newest_ns = (int(note[name]) for name in ("t_ns", "since_ns", "newest_ns"))
    if since_ns >= 0:
        lasted_s = (t_ns - since_ns) / NS_PER_S
        text = f"actuations arrive again; there was none in time for {lasted_s:.4g} s"
        return Notice(t_ns, "watchdog", text)
    age_s, timeout_s = ((ns / NS_PER_S) for ns in (t_ns - newest_ns, watchdog.timeout_ns))
    none = note["newest_sequence"] == NO_SEQUENCE
    what = "no actuation for" if none else "the newest actuation is too old:"
    name = INPUT_NAMES[watchdog.policy]
    text = f"{what} {age_s:.4g} s, {timeout_s:.4g} s allowed; the input is {name}"
    return Notice(t_ns, "watchdog", text)
