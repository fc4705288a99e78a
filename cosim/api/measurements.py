"""Measurements of a network from packet traces."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Literal

from cosim.measurement.measurement_outputs import write_page
from cosim.measurement.network_measurement import QUANTILES, MeasurementOptions, NetworkMeasurement
from cosim.measurement.network_section import write_network
from cosim.measurement.trace_sources import read_source
from noack.traces.packet_trace import find_trace


class Measurement(NetworkMeasurement):
    """The measurement of a network, which writes its page and a network that reproduces it."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the page of tables and figures (``.html``).

        Raises:
            NoackError: the name has another ending, or the file cannot be written.
        """
        write_page(self, None, Path(path))

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
        shares: shares of loss bursts and packets for which M is given.

    Raises:
        NoackError: a file cannot be read, or is not a trace.
    """
    trace = read_source([find_trace(str(source)) for source in sources])
    quantiles = QUANTILES if shares is None else tuple(shares)
    options = MeasurementOptions(deadline_s, quantiles, outage_s=outage_s)
    name = " ".join(str(Path(source)) for source in sources)
    return Measurement(trace, options, name, trace.notes)
