"""Measurements of real networks."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from cosim.measurement.network_measurement import Measurement, MeasurementOptions
from cosim.measurement.trace_sources import read_source
from noack.traces.trace_formats import find_trace


def measure(
    *sources: str | PathLike[str],
    deadline_s: float | None = None,
    outage_s: float | None = None,
    shares: Sequence[float] | None = None,
) -> Measurement:
    """Measure a network from a packet trace, as ``noack measure`` does.

    >>> import noack
    >>> found = noack.measure("rural_n8_10kmh", deadline_s=0.1)
    >>> found.longest_loss_burst >= 1
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
    options = MeasurementOptions(deadline_s=deadline_s, outage_s=outage_s)
    if shares is not None:
        options = MeasurementOptions(deadline_s, tuple(shares), outage_s=outage_s)
    return Measurement(trace, options, " ".join(str(Path(one)) for one in sources), trace.notes)
