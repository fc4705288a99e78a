"""Transmit when V(x) = xᵀPx is above an envelope that decays from the last event on.

    V(x(t)) > V(x(t_k)) e^{−ρ(t−t_k)}

(Mazo, Anta, Tabuada: Automatica 46(8), 2010, as a self-triggered rule.) Just after an event V lies
on its envelope. If the update arrives and ρ is less than the rate at which V decays under the
continuous control, V falls below; if it was lost nothing may pull it down, and the next test is
an event again. So nothing is known of its inter-event time under losses: it needs sampling, or a
dwell time.
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import QuadraticForm, empty_map, state_map
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class LyapunovTrigger:
    """The envelope rule.

    Args:
        factor: L with P = LᵀL, shape (n, n).
        rate_per_s: ρ > 0.
        weight: only for showing errors.
    """

    factor: Matrix
    rate_per_s: float
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        """The envelope that begins at the event."""
        form = QuadraticForm(state_map(n, self.factor), empty_map(n))
        return TriggerRule(form, rate_per_s=self.rate_per_s / 2, from_event=True)
