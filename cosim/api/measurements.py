"""Measurements of a network from packet traces."""

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Literal, TypeVar

from cosim.api.scenarios import Source, load
from cosim.measurement.certificate_time import CertificateTime, measured_certificate_time
from cosim.measurement.measurement_outputs import outputs_document
from cosim.measurement.network_section import write_network
from cosim.measurement.run_trace import read_source
from netem.core.file_access import require_suffix
from netem.core.number_checks import one_of
from netem.impairments.burst_prediction import USUAL_PACKETS
from netem.measurement.loss_bursts import WINDOWS
from netem.measurement.network_measurement import QUANTILES, MeasurementOptions, NetworkMeasurement
from netem.measurement.trace_sources import USUAL_PERIOD_NS, SourceOptions, probe_period_ns
from netem.traces.packet_trace import find_trace

Number = TypeVar("Number", int, float)


class Measurement(NetworkMeasurement):
    """The measurement of a network, which writes its page and a network that reproduces it.

    :func:`noack.measure` returns one. Times are in seconds.

    >>> import noack
    >>> network = noack.measure("rural_n8_10kmh", deadline_s=0.1)
    >>> 0 < network.certificate_time("lane_5g_rural").share < 1
    True
    """

    def certificate_time(self, scenario: Source) -> CertificateTime:
        """Return for which share of the time a scenario's certificates would have been void.

        Args:
            scenario: a scenario, or a source that :func:`noack.load` accepts.

        Raises:
            NoackError: the scenario is wrong, has several loops, or the delays are not known.
        """
        return measured_certificate_time(self, load(scenario))

    def save(self, path: str | PathLike[str]) -> None:
        """Write the page of tables and figures (``.html``).

        Raises:
            NoackError: the name has another ending, or the file cannot be written.
        """
        from cosim.output.page_kit import save_page  # imports matplotlib

        require_suffix(Path(path), "--out", ".html")
        save_page(outputs_document(self), Path(path))

    def write_network(self, path: str | PathLike[str], form: Literal["trace", "model"] = "trace") -> None:
        """Write a ``[network]`` section that reproduces the network (``.toml``).

        Raises:
            NoackError: the name has another ending, or a file cannot be written.
        """
        write_network(self, Path(path), form)


def measure(
    *sources: str | PathLike[str],
    deadline_s: float | None = None,
    outage_s: float | None = None,
    shares: Sequence[float] | None = None,
    windows: Sequence[int] | None = None,
    within: str | int | None = None,
    interval_s: float | None = None,
    survival_s: float | None = None,
    flow: int = 1,
    far_flow: int | None = None,
    sequence_at: str | None = None,
    bits: int | None = None,
    numbers: str | None = None,
    clocks: Literal["same", "different"] | None = None,
    period_s: float | None = None,
) -> Measurement:
    """Measure a network from a packet trace, as ``noack measure`` does.

    >>> import noack
    >>> network = noack.measure("rural_n8_10kmh", deadline_s=0.1)
    >>> network.longest_loss_burst >= 1
    True

    Args:
        sources: a file, the name of a shipped trace, or files that belong together.
        deadline_s: a packet that takes longer counts as lost.
        outage_s: loss bursts of this duration or more are outages; by default a test decides.
        shares: shares of loss bursts and packets for which the losses in a row are given.
        windows: K of the (m, K) table.
        within: packets, or a time such as ``"600s"``, for the chance of a long loss burst.
        interval_s: transfer interval of a service; by default the period of the trace.
        survival_s: its survival time, for ``observed_availability`` and ``predicted_availability``.
        flow: which flow of a capture; 1 is the largest.
        far_flow: which flow of a capture has the far end of the datagrams.
        sequence_at: where the payloads of a capture have sequence numbers, ``OFFSET:BYTES[:little]``.
        bits: the number is in so many lowest bits there.
        numbers: the range of the numbers, ``FIRST..LAST``.
        clocks: whether sending and receiving times were read on the same clock.
        period_s: period of the simulated probe through delivery opportunities.

    Raises:
        NoackError: a file cannot be read, or is not a trace; an option is wrong, or has no effect.
    """
    if clocks is not None:
        one_of("clocks", clocks, ("same", "different"))
    differ = None if clocks is None else clocks == "different"
    period_ns = USUAL_PERIOD_NS if period_s is None else probe_period_ns(period_s)
    reading = SourceOptions(differ, flow, far_flow, sequence_at, bits, numbers, period_ns)
    trace = read_source([find_trace(str(source)) for source in sources], reading)
    options = MeasurementOptions(
        deadline_s,
        QUANTILES if shares is None else _several(shares),
        WINDOWS if windows is None else _several(windows),
        outage_s,
        interval_s,
        survival_s,
        str(USUAL_PACKETS if within is None else within),
    )
    name = " ".join(str(Path(source)) for source in sources)
    return Measurement(trace, options, name, trace.notes)


def _several(values: Number | Sequence[Number]) -> tuple[Number, ...]:
    """Return numbers as a tuple, also a single one."""
    return tuple(values) if isinstance(values, Iterable) else (values,)
