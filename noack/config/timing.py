"""The times of a run that follow from its settings: periods, phases, timeouts."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from noack.core.clock import NS_PER_S
from noack.settings.section import period_ns

if TYPE_CHECKING:
    from noack.config.scenario import Scenario

_TIMEOUT_PERIODS = 5
_WATCHDOG_PERIODS = 50


@dataclass(frozen=True)
class Timing:
    """Periods, phases and timeouts of a scenario, in nanoseconds of simulated time."""

    scenario: "Scenario"

    @property
    def horizon_ns(self) -> int:
        """Length of the run."""
        return round(self.scenario.horizon_s * NS_PER_S)

    @property
    def plant_period_ns(self) -> int:
        """Period of the plant's steps."""
        return period_ns(self.scenario.plant.rate_hz)

    @property
    def measurement_period_ns(self) -> int:
        """Time between measurements."""
        return self.plant_period_ns * self.scenario.plant.measure_every

    @property
    def controller_period_ns(self) -> int:
        """Period of the controller's ticks."""
        return period_ns(self.scenario.controller.rate_hz)

    @property
    def controller_phase_ns(self) -> int:
        """Time of the controller's first tick."""
        return round(self.scenario.controller.phase * self.controller_period_ns)

    @property
    def actuation_timeout_ns(self) -> int:
        """Age of the newest actuation at which the plant's watchdog acts."""
        timeout_s = self.scenario.plant.watchdog.timeout_s
        if timeout_s is not None:
            return round(timeout_s * NS_PER_S)
        usual_ns = _WATCHDOG_PERIODS * self.controller_period_ns
        actuation = self.scenario.network.actuation
        if actuation is None:
            return max(usual_ns, self.predicted_ns)
        last_ns = self.predicted_ns + round(actuation.link.longest_delay_s * NS_PER_S)
        return max(usual_ns, last_ns) if self.scenario.plant.watchdog.policy == "hold" else last_ns

    @property
    def actuation_gap_ns(self) -> int | None:
        """Time by which losses and delays may hold up the newest actuation; None: no bound."""
        if (actuation := self.scenario.network.actuation) is None:
            return 0
        if (burst := actuation.link.longest_burst) is None:
            return None
        delay_ns = math.ceil(actuation.link.longest_delay_s * NS_PER_S)
        return burst * self.controller_period_ns + delay_ns

    @property
    def predicted_ns(self) -> int:
        """Time for which an actuation has inputs."""
        return self.scenario.controller.predictions * self.controller_period_ns

    @property
    def missing_actuation_ns(self) -> int:
        """Age of the newest actuation from which the plant reports that actuations are missing.

        The loss of a few is expected where they cross the network.
        """
        if self.scenario.network.actuation is None:
            return self.actuation_timeout_ns
        return max(self.actuation_timeout_ns, _WATCHDOG_PERIODS * self.controller_period_ns)

    @property
    def acknowledgement_timeout_ns(self) -> int:
        """How long the sensor waits for an acknowledgement before it transmits again."""
        network = self.scenario.network
        if network.reverse.timeout_s is not None:
            return round(network.reverse.timeout_s * NS_PER_S)
        round_trip_s = network.link.longest_delay_s + network.reverse.link.longest_delay_s
        return _TIMEOUT_PERIODS * self.measurement_period_ns + round(round_trip_s * NS_PER_S)
