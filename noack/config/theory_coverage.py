"""Which parts of the theory apply to a scenario."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.plants.linear import LinearSettings
from noack.trigger.decaying import DecayingSettings

if TYPE_CHECKING:
    from noack.config.scenario import Scenario


UNCERTIFIED_ACKNOWLEDGEMENTS = (
    "x_s is reset only when an acknowledgement returns, so ‖e_s‖ exceeds the threshold while the "
    "sensor waits, and (I1), on which every bound rests, does not hold"
)
"""Why the baseline with acknowledgements has no certificate."""


@dataclass(frozen=True)
class TheoryCoverage:
    """Which of the paper's theorems, the certificates and the exact simulation cover a scenario."""

    scenario: "Scenario"

    @property
    def is_decaying(self) -> bool:
        """Whether the trigger is the paper's."""
        return isinstance(self.scenario.trigger, DecayingSettings)

    @property
    def is_linear(self) -> bool:
        """Whether the plant is a linear system."""
        return isinstance(self.scenario.plant.system, LinearSettings)

    @property
    def knows_state(self) -> bool:
        """Whether the sensor measures the state itself, without noise."""
        return self.scenario.observer is None and not self.scenario.plant.measurement.is_noisy

    @property
    def is_certifiable(self) -> bool:
        """Whether certificates apply; the paper's theorems need its trigger as well."""
        return self.beyond_theory is None

    @property
    def is_undisturbed(self) -> bool:
        """Whether nothing disturbs the plant, and the sensor measures x."""
        return self.knows_state and not self.scenario.plant.disturbances

    @property
    def beyond_theory(self) -> str | None:
        """The first setting that certificates do not cover; None if all are."""
        return self._beyond_certificates or self.scenario.trigger.beyond_exact

    @property
    def _beyond_certificates(self) -> str | None:
        """The first setting besides the trigger that certificates do not cover."""
        scenario = self.scenario
        if scenario.protocol.acknowledges:
            return f'network.protocol = "ack": {UNCERTIFIED_ACKNOWLEDGEMENTS}'
        if not self.is_linear:
            return f'plant.system.kind = "{scenario.plant.system.kind}": the plant is not linear'
        if not scenario.controller.is_linear:
            return f'controller.kind = "{scenario.controller.kind}": u is not K x_c'
        return self._beyond_actuation

    @property
    def _beyond_actuation(self) -> str | None:
        """Why the age of the applied input has no bound, or the watchdog replaces the input."""
        timing, policy = self.scenario.timing, self.scenario.plant.watchdog.policy
        if (gap_ns := timing.actuation_gap_ns) is None:
            return (
                "network.actuation: without mansd or constraints, the age of the applied input has "
                "no bound"
            )
        oldest_ns = timing.controller_period_ns + gap_ns
        if gap_ns and policy != "hold" and timing.actuation_timeout_ns < oldest_ns:
            return (
                f'plant.watchdog.policy = "{policy}": it replaces the input after '
                f"{timing.actuation_timeout_ns / NS_PER_S:g} s, and an actuation may be "
                f"{oldest_ns / NS_PER_S:g} s old; use more controller.predictions, or a longer "
                "plant.watchdog.timeout_s"
            )
        return None

    @property
    def _beyond_linear(self) -> str | None:
        """The first setting besides the trigger with which the loop is not ẋ = A x + B K x_c."""
        scenario = self.scenario
        if (why := self._beyond_certificates) is not None:
            return why
        if scenario.network.actuation is not None:
            return "network.actuation: actuations may be lost or late"
        if scenario.plant.disturbances:
            kinds = ", ".join(one.kind for one in scenario.plant.disturbances)
            return f"plant.disturbances ({kinds}): the plant is disturbed"
        if scenario.observer is not None:
            return f'observer.kind = "{scenario.observer.kind}": the state is estimated'
        if scenario.plant.measurement.is_noisy:
            return "plant.measurement: the state is measured with noise"
        return None

    def require_constant(self) -> None:
        """Raise CallerError if the settings change."""
        if self.scenario.changes:
            raise CallerError(
                "changes: needs settings that stay the same during the run; "
                "leave changes out, or use --set changes=[]"
            )

    def require_unchanging(self) -> None:
        """Raise CallerError if the settings change, or the set point is not 0."""
        self.require_constant()
        if any(self.scenario.controller.setpoint or ()):
            raise CallerError("controller.setpoint: this needs the set point 0")

    def require_direct_inputs(self) -> None:
        """Raise CallerError unless every actuation reaches the plant and carries one input."""
        direct = self.scenario.network.actuation is None
        if direct and self.scenario.controller.predictions == 1:
            return
        key = "controller.predictions" if direct else "network.actuation"
        raise CallerError(
            f"{key}: needs actuations that reach the plant at once and carry one input"
        )

    def require_certifiable(self) -> None:
        """Raise CallerError if no certificate covers the scenario."""
        if (why := self.beyond_theory) is not None:
            raise CallerError(f"{why}; no certificate covers this")

    def require_exact(self) -> None:
        """Raise CallerError if exact simulation does not cover the scenario."""
        if (why := self._beyond_linear) is not None:
            raise CallerError(
                f"{why}; this needs a linear plant with u = K x_c, without acknowledgements, "
                "lost actuations, disturbances, noise and observer"
            )
        if (why := self.scenario.trigger.beyond_exact) is not None:
            raise CallerError(why)
