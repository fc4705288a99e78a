"""The number of vector entries in each message of a run."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from noack.protocol.wire_format import Flow

if TYPE_CHECKING:
    from noack.config.scenario import Scenario


@dataclass(frozen=True)
class MessageSizes:
    """Number of vector entries per message of a scenario, by flow."""

    scenario: "Scenario"

    @property
    def outputs(self) -> int:
        """The number p of measured outputs."""
        return self.scenario.plant.measurement.outputs(self.scenario.model.dimensions[0])

    @property
    def inputs_reported(self) -> int:
        """Number of applied inputs in a measurement: m per plant step since the last measurement.

        Only an observer needs them; without an observer it is 0.
        """
        if self.scenario.observer is None:
            return 0
        return self.scenario.plant.measure_every * self.scenario.model.dimensions[1]

    @property
    def measurement_entries(self) -> int:
        """Number of entries of a measurement: y, or y and the applied inputs since the last one."""
        return self.outputs + self.inputs_reported

    @property
    def is_predictive(self) -> bool:
        """Whether actuations carry the controller's model state."""
        return self.scenario.plant.watchdog.policy == "model"

    @property
    def actuation_entries(self) -> int:
        """Number of entries of an actuation: its inputs, with x_c if it is predictive."""
        n, m = self.scenario.model.dimensions
        return m * self.scenario.controller.predictions + n * self.is_predictive

    def entries(self, flow: Flow) -> int:
        """Number of entries of a message of a flow."""
        return {
            Flow.MEASUREMENT: self.measurement_entries,
            Flow.UPDATE: self.scenario.model.dimensions[0],
            Flow.ACTUATION: self.actuation_entries,
            Flow.ACKNOWLEDGEMENT: 0,
        }[flow]
