"""A link that behaves as a measured network: loss model, outages, and delays, as impairments."""

from collections.abc import Iterator, Mapping

import numpy as np

from netem.measurement.chain_fits import ChainFit
from netem.measurement.network_measurement import NetworkMeasurement

_SAMPLES = 101
"""Number of delay quantiles of a model."""
_MOST_CORRELATION = 0.99
"""The emulator requires less than 1."""


def fitted_loss(measurement: NetworkMeasurement) -> Mapping[str, object]:
    """Return the preferred loss model, a table as in settings files."""
    if not measurement.models:
        return {"model": "lossless"}
    fit: ChainFit = measurement.chosen.fit
    if fit.model == "bernoulli":
        return {"model": "bernoulli", "probability": fit.rates.loss_in_bad}
    return {"model": "gilbert_elliott", **fit.rates._asdict()}


def fitted_impairments(
    measurement: NetworkMeasurement, *, ordered: bool = False
) -> Iterator[Mapping[str, object]]:
    """Yield the outages as a chain of their own, by packets, and the delays of effective packets.

    Packets that are not effective are lost in the model. ``ordered``: delays keep the order of a flow.
    """
    lengths = measurement.bursts.length[measurement.is_outage]
    if len(lengths):
        usual = len(measurement.trace) - int(lengths.sum())
        chain = {
            "model": "gilbert_elliott",
            "good_to_bad": min(len(lengths) / max(usual, 1), 1.0),
            "bad_to_good": 1 / float(lengths.mean()),
        }
        yield {"kind": "loss", "loss": chain}
    delays_ns = measurement.trace.delay_ns[measurement.outcomes.effective]
    if not len(delays_ns) or not delays_ns.any():
        return
    if delays_ns.min() == delays_ns.max():
        yield {"kind": "delay", "delay_s": int(delays_ns[0]) * 1e-9}
        return
    samples_s = np.quantile(delays_ns, np.linspace(0, 1, _SAMPLES)) * 1e-9
    correlation = next(iter(measurement.delays.correlation.at_lags), 0.0)
    delay = {
        "kind": "delay",
        "distribution": "empirical",
        "samples_s": np.round(samples_s, 9).tolist(),
        "correlation": round(min(max(correlation, 0.0), _MOST_CORRELATION), 4),
    }
    yield delay | ({"ordered": True} if ordered else {})
