"""Which parts of the theory apply to a scenario."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from noack.core.errors import CallerError
from noack.plants.linear import LinearSettings
from noack.trigger.decaying import DecayingSettings

if TYPE_CHECKING:
    from noack.config.scenario import Scenario


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
        """Whether the paper's theorems and the certificates apply."""
        return self.beyond_theory is None

    @property
    def beyond_theory(self) -> str | None:
        """The first setting that the theorems and certificates do not cover; None if all are."""
        scenario = self.scenario
        if scenario.protocol.acknowledges:
            return 'network.protocol = "ack": updates are acknowledged'
        if not self.is_linear:
            return f'plant.system.kind = "{scenario.plant.system.kind}": the plant is not linear'
        if not scenario.controller.is_linear:
            return f'controller.kind = "{scenario.controller.kind}": u is not K x_c'
        if scenario.plant.disturbances:
            kinds = ", ".join(one.kind for one in scenario.plant.disturbances)
            return f"plant.disturbances ({kinds}): the plant is disturbed"
        if scenario.observer is not None:
            return f'observer.kind = "{scenario.observer.kind}": the state is estimated'
        if scenario.plant.measurement.is_noisy:
            return "plant.measurement: the state is measured with noise"
        if not self.is_decaying:
            return f'trigger.policy = "{scenario.trigger.policy}": not the paper\'s trigger'
        return None

    def require_unacknowledged(self) -> None:
        """Raise CallerError if updates are acknowledged."""
        if self.scenario.protocol.acknowledges:
            raise CallerError(
                'network.protocol: needs the loop without acknowledgements, "none"; '
                'this scenario has "ack"'
            )

    def require_unchanging(self) -> None:
        """Raise CallerError if the settings change, or the set point is not 0."""
        if self.scenario.changes:
            raise CallerError(
                "changes: needs settings that stay the same during the run; "
                "leave changes out, or use --set changes=[]"
            )
        if any(self.scenario.controller.setpoint or ()):
            raise CallerError("controller.setpoint: needs the set point 0")

    def require_linear(self) -> None:
        """Raise CallerError if the plant is not linear."""
        if not self.is_linear:
            raise CallerError(
                'plant.system.kind: needs a linear plant, "linear"; '
                f'this scenario has "{self.scenario.plant.system.kind}"'
            )

    def require_exact(self) -> None:
        """Raise CallerError if exact simulation does not cover the scenario."""
        self.require_linear()
        scenario = self.scenario
        if not scenario.controller.is_linear:
            raise CallerError(
                'controller.kind: needs the controller u = K x_c, "linear"; '
                f'this scenario has "{scenario.controller.kind}"'
            )
        if scenario.plant.disturbances:
            kinds = ", ".join(f'"{one.kind}"' for one in scenario.plant.disturbances)
            raise CallerError(
                f"plant.disturbances: needs an undisturbed plant; this scenario has {kinds}"
            )
        if scenario.observer is not None:
            raise CallerError(
                "observer: needs a sensor that measures the state itself; "
                f'this scenario has "{scenario.observer.kind}"'
            )
        if scenario.plant.measurement.is_noisy:
            raise CallerError(
                "plant.measurement: needs a sensor without noise; "
                "this scenario has noise_std or noise_bound"
            )
        if (why := scenario.trigger.beyond_exact) is not None:
            raise CallerError(why)
