"""Availability and mean time between failures, against counting, stationary chains and closed forms."""

import numpy as np
import pytest

from netem.core.errors import CallerError
from netem.core.number_format import availability_percent, long_duration
from netem.measurement.availability import Service, chain_availability, message_indices, observed_availability
from netem.measurement.chain_fits import ChainRates
from netem.measurement.loss_bursts import LossBursts, loss_bursts
from netem.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from netem.traces.packet_trace import packet_trace
from tests.netem.measurement.chains import ELLIOTT, GILBERT, chain_losses, trace_of

SERVICES = [Service(0.01, survival_s) for survival_s in (0.0, 0.004, 0.01, 0.03, 0.0375, 0.2)]
LONGEST = 600
"""Longest burst of the independent computation; longer ones have a probability below 1e-15."""


def stationary(rates: ChainRates, service: Service) -> tuple[float, float]:
    """Unavailable share and failures per message, of the chain of (state, losses up to here)."""
    p, r, *loss = rates
    step = np.array([[1 - p, p], [r, 1 - r]])
    share = np.array([r, p]) / (p + r)
    # mass[n][s]: the message was the n-th lost in a row, in state s; for n = 0 it was delivered.
    delivered = np.array([share[state] * (1 - loss[state]) for state in (0, 1)])
    unavailable = failures = 0.0
    mass = delivered
    for lost in range(1, LONGEST):
        mass = np.array([sum(mass[s] * step[s, t] for s in (0, 1)) * loss[t] for t in (0, 1)])
        if lost * service.interval_s > service.survival_s * (1 + 1e-9):
            begins_s = max((lost - 1) * service.interval_s, service.survival_s)
            unavailable += mass.sum() * (lost * service.interval_s - begins_s) / service.interval_s
            is_first = (lost - 1) * service.interval_s <= service.survival_s * (1 + 1e-9)
            failures += mass.sum() if is_first else 0.0
    return unavailable, failures


@pytest.mark.parametrize("service", SERVICES)
@pytest.mark.parametrize(
    "rates",
    [
        GILBERT,
        ELLIOTT,
        ChainRates(0.3, 0.05, 0.2, 0.95),
        ChainRates(0.9, 0.8, 0.0, 0.5),
        ChainRates(1, 1, 0, 1),
    ],
)
def test_a_chain_has_the_availability_of_its_stationary_distribution(
    rates: ChainRates, service: Service
) -> None:
    unavailable, failures = stationary(rates, service)
    found = chain_availability(rates, service)
    assert found.unavailability == pytest.approx(unavailable, rel=1e-9, abs=1e-15)
    assert found.failures_per_message == pytest.approx(failures, rel=1e-9, abs=1e-15)
    if failures > 1e-12:
        available_s = (1 - unavailable) * service.interval_s
        assert found.mean_time_between_failures_s == pytest.approx(available_s / failures, rel=1e-9)


@pytest.mark.parametrize("probability", [1e-4, 0.1, 0.7])
@pytest.mark.parametrize("service", SERVICES)
def test_independent_losses_have_the_closed_form(probability: float, service: Service) -> None:
    """n + 1 losses in a row after a delivery are a failure; the rest of the survival time is available."""
    found = chain_availability(ChainRates(0.5, 0.5, probability, probability), service)
    n, rest = service.survived, service.survival_s / service.interval_s - service.survived
    begins = (1 - probability) * probability ** (n + 1)
    assert found.failures_per_message == pytest.approx(begins, rel=1e-9)
    assert found.unavailability == pytest.approx(probability ** (n + 1) - rest * begins, rel=1e-9)


def test_a_trace_is_counted() -> None:
    """Bursts of 2, 4 and 5 among 100 messages of 10 ms; 30 ms are survived."""
    bursts = LossBursts(100, np.array([3, 20, 95]), np.array([2, 4, 5]))
    observed = observed_availability(bursts, Service(0.01, 0.03))
    assert (observed.failures, observed.messages) == (2, 100)
    assert observed.unavailable_s == pytest.approx(0.01 + 0.02)
    assert observed.availability.value == pytest.approx(0.97)
    assert observed.mean_time_between_failures_s.value == pytest.approx(0.97 / 2)
    partly = observed_availability(bursts, Service(0.01, 0.025))
    assert partly.unavailable_s == pytest.approx(0.015 + 0.025)
    none = observed_availability(bursts, Service(0.01, 0.05))
    assert none.failures == 0
    assert none.availability == (1.0, None, 1.0)
    # 0 events in 1 s: at most 3.69 /s, with 97.5 %.
    assert none.mean_time_between_failures_s.low == pytest.approx(1 / 3.6889, rel=1e-4)
    assert none.mean_time_between_failures_s.high is None
    lost = observed_availability(LossBursts(10, np.array([0]), np.array([10])), Service(0.01, 0.0))
    assert lost.availability.value == 0.0


@pytest.mark.parametrize("rates", [GILBERT, ELLIOTT])
def test_intervals_contain_the_truth_as_often_as_they_say(rates: ChainRates) -> None:
    """Of 300 traces at least 92 %: the nominal 95 % less three standard errors would be 91.2 %."""
    service = Service(0.02, 0.06)
    truth = chain_availability(rates, service)
    hits = {"availability": 0, "mtbf": 0}
    for seed in range(300):
        bursts = loss_bursts(~chain_losses(4000, rates, seed))
        observed = observed_availability(bursts, service)
        _, low, high = observed.availability
        hits["availability"] += (low or 0.0) <= truth.availability <= (high or 1.0)
        _, low, high = observed.mean_time_between_failures_s
        hits["mtbf"] += (low or 0.0) <= truth.mean_time_between_failures_s <= (high or np.inf)
    assert min(hits.values()) >= 0.92 * 300


def test_a_measured_network_has_the_availability_of_its_losses() -> None:
    trace = trace_of(chain_losses(30_000, GILBERT, 5))
    options = MeasurementOptions(survival_s=0.06)
    measurement = NetworkMeasurement(trace, options)
    assert measurement.service == Service(0.02, 0.06)
    truth = chain_availability(GILBERT, Service(0.02, 0.06))
    predicted = measurement.predicted_availability
    assert predicted is not None
    assert predicted.unavailability == pytest.approx(truth.unavailability, rel=0.2)
    assert measurement.observed_availability.unavailability == pytest.approx(truth.unavailability, rel=0.2)
    document = measurement.to_json()["availability"]
    assert isinstance(document, dict)
    assert document["losses_survived"] == 3
    lossless = NetworkMeasurement(trace_of(np.zeros(100, bool)), options)
    assert lossless.predicted_availability is None
    assert lossless.observed_availability.failures == 0


def test_a_longer_interval_takes_the_packets_nearest_to_its_multiples() -> None:
    lost = np.zeros(101, bool)
    lost[[4, 8, 50]] = True
    trace = trace_of(lost)  # every 20 ms
    assert message_indices(trace, 0.08)[0].tolist() == list(range(0, 101, 4))
    assert len(message_indices(trace, 0.02001)[0]) == 101
    measurement = NetworkMeasurement(trace, MeasurementOptions(interval_s=0.08, survival_s=0.08))
    observed = measurement.observed_availability
    assert (observed.messages, observed.failures) == (26, 1)
    assert observed.unavailable_s == pytest.approx(0.08)
    pause = packet_trace(np.array([0, 1, 10]) * 10**9, np.array([0, 1, 10]) * 10**9, np.zeros(3, bool))
    assert message_indices(pause, 5.0)[0].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("interval_s", "survival_s", "message"),
    [
        (0.01, 0.03, "--interval 0.01 s: shorter than the time between two packets of the trace, 0.02 s"),
        (0.01, None, "--interval: is the transfer interval of a service; give --survival, too"),
        (None, -1.0, "survival -1 s: must be 0 or more"),
        (0.0, 1.0, "interval 0: expected more than 0"),
        (None, 1e7, "survival 1e+07 s: more than 10,000,000 transfer intervals"),
    ],
)
def test_a_wrong_service_is_refused_in_one_line(
    interval_s: float | None, survival_s: float | None, message: str
) -> None:
    with pytest.raises(CallerError) as error:
        NetworkMeasurement(
            trace_of(np.zeros(50, bool)), MeasurementOptions(None, (), (), None, interval_s, survival_s)
        )
    assert str(error.value).startswith(message)


def test_texts_have_the_digits_that_matter() -> None:
    assert [availability_percent(share) for share in (0.0, 0.5, 0.0123, 1.234e-7, 1.0)] == [
        "100 %", "50.00 %", "98.77 %", "99.999987 %", "0 %",
    ]  # fmt: skip
    assert [long_duration(time_s) for time_s in (0.5, 1800.0, 7200.0, 2e5, 4e8)] == [
        "500 ms", "1800 s", "2 h", "2.31 days", "12.7 years",
    ]  # fmt: skip
