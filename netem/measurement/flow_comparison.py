"""Several flows of one source, each measured, the worst first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from netem.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from netem.measurement.trace_sources import FlowTrace


class MeasuredFlow(NamedTuple):
    """A flow with its measurement."""

    number: int
    name: str
    measurement: NetworkMeasurement

    @property
    def loss_rate(self) -> float:
        """Share of packets that are not effective."""
        return self.measurement.bursts.losses / len(self.measurement.trace)

    def to_json(self) -> Mapping[str, object]:
        """Return what a row has, for JSON."""
        measurement = self.measurement
        jitter = measurement.delays.jitter
        return {
            "flow": self.number,
            "name": self.name,
            "packets": len(measurement.trace),
            "observed_s": measurement.observed_s,
            "effective_losses": measurement.bursts.losses,
            "loss_rate": self.loss_rate,
            "longest": measurement.bursts.longest,
            "mansd": measurement.longest_loss_burst,
            "outages": int(measurement.is_outage.sum()),
            "delay_s": {str(share): value for share, value in measurement.delays.quantiles_s.items()},
            "jitter_s": None if jitter is None else jitter._asdict(),
            "remarks": list(measurement.notes),
        }


@dataclass(frozen=True)
class FlowComparison:
    """The flows of a source."""

    measured: Sequence[MeasuredFlow]
    """The worst first: by loss rate, then by the longest burst, then by the largest delay."""
    not_measured: Sequence[FlowTrace]
    left_out: int
    """Number of further, smaller flows."""


def compare_flows(flows: Sequence[FlowTrace], left_out: int, options: MeasurementOptions) -> FlowComparison:
    """Measure flows.

    Raises:
        CallerError: an option is wrong, or no flow has the delays that it needs.
    """
    measured = [
        MeasuredFlow(
            flow.number, flow.name, NetworkMeasurement(flow.trace, options, flow.name, flow.trace.notes)
        )
        for flow in flows
        if flow.trace is not None
    ]

    def badness(flow: MeasuredFlow) -> tuple[float, int, float]:
        largest_s = flow.measurement.delays.quantiles_s.get(1.0, 0.0)
        return flow.loss_rate, flow.measurement.bursts.longest, largest_s

    return FlowComparison(
        sorted(measured, key=badness, reverse=True), [flow for flow in flows if flow.trace is None], left_out
    )
