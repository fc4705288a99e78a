"""The correlation of delays against its process, and any trace."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import noack
from cosim.measurement.certificate_time import measured_certificate_time
from cosim.measurement.measurement_outputs import measurement_figures, outputs_document
from netem.measurement.network_measurement import (
    MeasurementOptions,
    NetworkMeasurement,
    autocorrelation,
    normal_scores,
)
from netem.traces.packet_trace import packet_trace


def test_correlation_is_that_of_an_autoregressive_delay() -> None:
    rng, z = np.random.default_rng(1), np.zeros(20_000)
    for k in range(1, len(z)):
        z[k] = 0.8 * z[k - 1] + 0.6 * rng.normal()
    delay_ns = np.exp(15 + z).astype(np.int64)
    known = rng.random(len(z)) > 0.2
    lags, correlations = autocorrelation(delay_ns, known)
    for lag, correlation in list(zip(lags, correlations, strict=True))[:5]:
        assert correlation == pytest.approx(0.8**lag, abs=0.04)
    scores = normal_scores(np.array([5, 1, 1, 9]))
    assert scores[1] == scores[2] < scores[0] < scores[3]
    sent = 10**8 * np.arange(len(z))
    trace = packet_trace(sent, sent + delay_ns, ~known)
    delays = NetworkMeasurement(trace).delays
    assert delays.quantiles_s[0.5] == pytest.approx(np.median(delay_ns[known]) * 1e-9)
    assert delays.received == known.sum()


@settings(max_examples=6, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 10**9), st.none() | st.integers(0, 10**12)),
        min_size=1,
        max_size=40,
    ),
    st.none() | st.floats(1e-9, 1e3),
)
def test_any_trace_is_measured(records: list[tuple[int, int | None]], deadline_s: float) -> None:
    sent = np.cumsum([gap for gap, _ in records])
    lost = np.array([delay is None for _, delay in records])
    received = sent + np.array([delay or 0 for _, delay in records])
    trace = packet_trace(sent, received, lost)
    measurement = NetworkMeasurement(trace, MeasurementOptions(deadline_s=deadline_s))
    with np.errstate(all="raise", under="ignore"):
        document = measurement.to_json()
    assert document["effective_losses"] >= int(lost.sum())
    void = measured_certificate_time(measurement, noack.load("lane_following"))
    assert 0 <= void.share <= 1
    assert all(cause.share <= void.share for cause in void.causes)
    assert outputs_document(measurement, void).tables
    assert len([*measurement_figures(measurement)]) == 4
