"""The measurement of a network from a packet trace: all statistics, fits and tests."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import ndtri

from netem.core.errors import CallerError
from netem.core.number_checks import real_number, whole_number
from netem.impairments.burst_prediction import (
    USUAL_PACKETS,
    BurstPrediction,
    caps_with,
    predict_bursts,
    read_within,
)
from netem.impairments.loss_prediction import LossProcess
from netem.measurement.availability import (
    ChainAvailability,
    ObservedAvailability,
    Service,
    chain_availability,
    message_indices,
    observed_availability,
    to_json,
)
from netem.measurement.chain_fits import MOST_FITTED, ChainFit, ChainFits, FitTest
from netem.measurement.interval_estimates import LEVEL, IntervalEstimate
from netem.measurement.loss_bursts import (
    WINDOWS,
    BurstQuantile,
    Flags,
    LossBursts,
    Outcomes,
    burst_quantile,
    histogram,
    loss_bursts,
    most_losses,
    outcomes,
)
from netem.measurement.outages import OutageFit, OutageRule, find_outages, fit_outages, outages_longer_than
from netem.traces.packet_trace import PacketTrace

Reals = NDArray[np.float64]
QUANTILES = (0.5, 0.9, 0.99, 0.999)
"""Shares of bursts and packets for which the largest number of losses in a row is given."""
SHARES = (0.0, 0.05, 0.5, 0.9, 0.95, 0.99, 0.999, 1.0)
"""Shares of the packets for which a delay is given."""
_MOST_LAGS, _LARGEST_LAG = 40, 1000
"""Number of distances of a correlation, and the largest one, in packets."""
_FEWEST_PAIRS = 30
"""Pairs of packets below which no correlation is given."""
_FEW_BURSTS = 20
"""Fewer bursts than these are called few."""
_LONGEST_S, _LONGEST_WINDOW = 1e8, 100_000_000
"""Largest deadline and duration of an outage, and largest K of the (m, K) table."""
_MOST_RANKED = 1_000_000
"""Number of packets, the first ones, of which correlations are computed."""


class Correlation(NamedTuple):
    """The correlation of the normal scores of two packets' values, at some distances.

    Scores have only the ranks of the values, so that a few very large ones do not outweigh all
    others.
    """

    lags: tuple[int, ...]
    """Distances in packets."""
    at_lags: tuple[float, ...]


@dataclass(frozen=True)
class DelayStatistics:
    """Delays in seconds; empty if no packet was received, or delays are not known."""

    received: int
    quantiles_s: dict[float, float]
    """By share of the received packets."""
    correlation: Correlation
    """Of the delays of two packets. The emulator's ``delay … CORRELATION`` is that at lag 1."""
    white_noise_limit: float
    """Size below which 95 % of the correlations of independent delays are."""
    jitter: "Jitter | None" = None


class Jitter(NamedTuple):
    """The interarrival jitter of RFC 3550, Section 6.4.1, in seconds."""

    last_s: float
    """After the last packet."""
    largest_s: float


def interarrival_jitter(trace: PacketTrace) -> Jitter | None:
    """Return the jitter J, with J ← J + (|D| − J)/16 for the difference D of two packets' delays.

    The packets are those received, in the order of their arrival. With fewer than two there is none.
    """
    arrived = np.flatnonzero(~trace.lost)
    order = arrived[np.argsort(trace.received_ns[arrived], kind="stable")]
    differences = np.abs(np.diff(trace.delay_ns[order])).astype(np.float64)
    if not len(differences):
        return None
    jitter_ns = lfilter([1 / 16], [1, -15 / 16], differences)
    return Jitter(float(jitter_ns[-1]) * 1e-9, float(jitter_ns.max()) * 1e-9)


def delay_statistics(trace: PacketTrace, in_outage: Flags) -> DelayStatistics:
    """Return the statistics of the packets that were received, in order or not.

    The correlation is that of packets that are not in an outage, (k,) flags.
    """
    arrived = ~trace.lost & (trace.delays_unknown == "")
    delays_ns = trace.delay_ns[arrived]
    if not len(delays_ns):
        return DelayStatistics(0, {}, Correlation((), ()), 0.0)
    quantiles = np.quantile(delays_ns, SHARES) * 1e-9
    return DelayStatistics(
        len(delays_ns),
        dict(zip(SHARES, quantiles.tolist(), strict=True)),
        autocorrelation(trace.delay_ns, arrived & ~in_outage),
        1.96 / np.sqrt(len(delays_ns)),
        interarrival_jitter(trace),
    )


def normal_scores(values: NDArray[np.int64]) -> Reals:
    """Return Φ⁻¹ of the middle ranks of values, equal ones with the same rank, scaled, (k,)."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    scores = ndtri((last - counts / 2) / len(values))[inverse]
    deviation = scores.std()
    return np.asarray((scores - scores.mean()) / deviation if deviation > 0 else 0.0 * scores)


def autocorrelation(values: NDArray[np.int64], known: NDArray[np.bool_]) -> Correlation:
    """Return the correlation of the known ones of k values; empty if they do not vary."""
    values, known = values[:_MOST_RANKED], known[:_MOST_RANKED]
    if not known.any():
        return Correlation((), ())
    scores = np.zeros(len(known))
    scores[known] = normal_scores(values[known])
    if not scores.any():
        return Correlation((), ())
    furthest = max(min(_LARGEST_LAG, len(known) // 4), 1)
    lags, correlations = [], []
    for lag in np.unique(np.geomspace(1, furthest, _MOST_LAGS).round()).astype(int).tolist():
        pairs = int(np.count_nonzero(known[lag:] & known[:-lag]))
        if pairs >= _FEWEST_PAIRS:
            lags.append(lag)
            correlations.append(float(scores[lag:] @ scores[:-lag] / pairs))
    return Correlation(tuple(lags), tuple(correlations))


@dataclass(frozen=True)
class MeasurementOptions:
    """What is measured."""

    deadline_s: float | None = None
    """A packet that arrives later than this after its sending counts as lost."""
    quantiles: Sequence[float] = QUANTILES
    """Shares of bursts and packets for which the largest number of losses in a row is given."""
    windows: Sequence[int] = WINDOWS
    """K of the (m, K) table."""
    outage_s: float | None = None
    """Bursts of this duration or more are outages; None: the statistical rule."""
    interval_s: float | None = None
    """Transfer interval of a service, of which the availability is measured; None: the trace's period."""
    survival_s: float | None = None
    """Its survival time; None: no availability is measured."""
    within: str = str(USUAL_PACKETS)
    """Packets, or a time, within which the chance of a long loss burst is given."""

    def __post_init__(self) -> None:
        """Raise CallerError for a number that is out of range."""
        for name, time_s in (("deadline", self.deadline_s), ("outage", self.outage_s)):
            if time_s is not None:
                real_number(name, time_s, above=0.0, most=_LONGEST_S)
        if self.interval_s is not None and self.survival_s is None:
            raise CallerError("--interval: is the transfer interval of a service; give --survival, too")
        for share in self.quantiles:
            real_number("share", share, above=0.0, most=1.0)
        for window in self.windows:
            whole_number("window", window, 1, _LONGEST_WINDOW)


class WindowLosses(NamedTuple):
    """The most losses in windows of a length."""

    in_all: int
    without_outages: int | None
    """In windows without an outage; None if there are none."""


class FittedModel(NamedTuple):
    """A loss model, fitted to the bursts that are no outages, with its test."""

    fit: ChainFit
    test: FitTest

    def to_json(self) -> dict[str, object]:
        """Return the fit for JSON."""
        return {
            "model": self.fit.model,
            "estimates": {name: _interval(estimate) for name, estimate in self.fit.estimates.items()},
            "loss_rate": self.fit.rates.loss_rate,
            "log_likelihood": self.fit.log_likelihood,
            "test": asdict(self.test) | {"verdict": self.test.verdict},
        }


@dataclass(frozen=True, eq=False)
class NetworkMeasurement:
    """A measured network; each property is computed once, when first used."""

    trace: PacketTrace
    options: MeasurementOptions = field(default_factory=MeasurementOptions)
    name: str = "trace"
    notes: Sequence[str] = ()
    """How the trace was obtained."""

    def __post_init__(self) -> None:
        """Refuse a deadline without delays, and a wrong time or number of packets."""
        _ = self._predicted_packets, self.service
        if self.options.deadline_s is not None:
            self.require_delays("a deadline (--deadline)")

    def require_delays(self, what: str) -> None:
        """Raise CallerError if delays, or the number of losses, are not known, naming what needs them."""
        if self.trace.delays_unknown:
            raise CallerError(
                f"{self.name}: {what} needs delays; they are not known: {self.trace.delays_unknown}"
            )
        if self.trace.losses_ambiguous:
            raise CallerError(
                f"{self.name}: {what} needs the number of losses, which is not certain: "
                f"{self.trace.losses_ambiguous}"
            )

    @cached_property
    def outcomes(self) -> Outcomes:
        """What became of each packet."""
        deadline_s = self.options.deadline_s
        return outcomes(self.trace, None if deadline_s is None else round(deadline_s * 1e9))

    @cached_property
    def bursts(self) -> LossBursts:
        """All loss bursts, outages included."""
        return loss_bursts(self.outcomes.effective)

    @cached_property
    def outage_rule(self) -> OutageRule:
        """Which of the bursts are outages."""
        if self.options.outage_s is not None:
            return outages_longer_than(self.bursts.times_s(self.trace)[1], self.options.outage_s)
        return find_outages(self.bursts)

    @property
    def is_outage(self) -> Flags:
        """(b,) Which bursts are outages."""
        return self.outage_rule.flags

    @property
    def observed_s(self) -> float:
        """Time from the first to the last sending."""
        return float(self.trace.sent_ns[-1]) * 1e-9

    @cached_property
    def longest_loss_burst(self) -> int:
        """The longest burst that is no outage; its length is the network's ``mansd``."""
        return self.bursts.subset(~self.is_outage).longest

    @cached_property
    def quantiles(self) -> list[BurstQuantile]:
        """The losses in a row for shares of bursts and packets, without the outages."""
        usual = self.bursts.subset(~self.is_outage)
        packets = usual.packets - int(self.bursts.length[self.is_outage].sum())
        usual = LossBursts(packets, usual.first, usual.length)
        return [burst_quantile(usual, share) for share in self.options.quantiles]

    @cached_property
    def windows(self) -> dict[int, WindowLosses]:
        """By K: the most losses in K consecutive packets."""
        lengths = sorted({int(window) for window in self.options.windows})
        in_all = most_losses(self.bursts, lengths)
        without_outages = most_losses(self.bursts, lengths, self.is_outage)
        return {window: WindowLosses(most, without_outages.get(window)) for window, most in in_all.items()}

    @cached_property
    def delays(self) -> DelayStatistics:
        """Delays of the received packets."""
        return delay_statistics(self.trace, self.in_outage)

    @cached_property
    def in_outage(self) -> Flags:
        """(k,) Which packets belong to an outage."""
        outages = self.bursts.subset(self.is_outage)
        steps = np.zeros(len(self.trace) + 1, np.int64)
        steps[outages.first] += 1
        steps[outages.end] -= 1
        return np.cumsum(steps)[:-1] > 0

    @cached_property
    def loss_correlation(self) -> Correlation:
        """The correlation of the effective losses of two packets that are not in an outage."""
        return autocorrelation(self.outcomes.effective.astype(np.int64), ~self.in_outage)

    @cached_property
    def _fits(self) -> ChainFits:
        return ChainFits(self.bursts, self.is_outage)

    @cached_property
    def models(self) -> dict[str, FittedModel]:
        """The fitted loss models, by name; empty without losses."""
        return {fit.model: FittedModel(fit, self._fits.test(fit)) for fit in self._fits.all()}

    @cached_property
    def chosen(self) -> FittedModel:
        """The model that the Bayesian information criterion prefers."""
        return FittedModel(self._fits.chosen, self._fits.test(self._fits.chosen))

    @property
    def mean_burst(self) -> float | None:
        """Mean length of the loss bursts, without the outages; None: there are none."""
        lengths = self.bursts.length[~self.is_outage]
        return float(lengths.mean()) if len(lengths) else None

    @cached_property
    def burst_prediction(self) -> BurstPrediction | None:
        """The chance of a long loss burst, by the preferred model; None without losses."""
        if not self.models:
            return None
        rates = self.chosen.fit.rates
        start, delivers, loses = rates.matrices()
        lost = np.array([rates.loss_in_good, rates.loss_in_bad])
        process = LossProcess(start, delivers + loses, lost, first_delivered=False)
        caps = {*caps_with(self.longest_loss_burst), *(quantile.bursts for quantile in self.quantiles)}
        return predict_bursts(process, sorted(caps - {0}), self._predicted_packets)

    @cached_property
    def _predicted_packets(self) -> int:
        """Packets within which the chance of a long loss burst is given."""
        period_s = self.observed_s / max(len(self.trace) - 1, 1)
        try:
            return read_within(self.options.within, period_s)
        except ValueError as error:
            raise CallerError(f"--within {self.options.within}: {error}") from None

    @cached_property
    def service(self) -> Service | None:
        """The service of which the availability is measured, if there is one."""
        if self.options.survival_s is None:
            return None
        _, interval_s = message_indices(self.trace, self.options.interval_s)
        return Service(interval_s, self.options.survival_s)

    @cached_property
    def _messages(self) -> tuple[LossBursts, Flags]:
        """The loss bursts of the service's messages, and which of them are in an outage."""
        chosen, _ = message_indices(self.trace, self.options.interval_s)
        bursts = loss_bursts(self.outcomes.effective[chosen])
        return bursts, self.in_outage[chosen][bursts.first] if len(bursts.first) else np.zeros(0, bool)

    @property
    def observed_availability(self) -> ObservedAvailability:
        """The availability of the service in the trace, outages included."""
        assert self.service is not None
        return observed_availability(self._messages[0], self.service)

    @cached_property
    def availability_model(self) -> ChainFit | None:
        """The preferred loss model of the service's messages, without outages; None without losses."""
        bursts, left_out = self._messages
        fits = ChainFits(bursts, left_out)
        return fits.chosen if fits.lost else None

    @property
    def predicted_availability(self) -> ChainAvailability | None:
        """The availability of the service by this model, without outages; None without losses."""
        assert self.service is not None
        fit = self.availability_model
        return None if fit is None else chain_availability(fit.rates, self.service)

    def longer_bursts(self, cap: int) -> int:
        """Return the number of loss bursts of more than ``cap`` packets, without the outages."""
        return int(np.count_nonzero(self.bursts.length[~self.is_outage] > cap))

    @cached_property
    def outage_fit(self) -> OutageFit:
        """The model of the outages."""
        durations_s = self.bursts.times_s(self.trace)[1][self.is_outage]
        return fit_outages(durations_s, self.bursts.complete[self.is_outage], self.observed_s)

    @cached_property
    def remarks(self) -> list[str]:
        """What the reader of the numbers must know, in plain words."""
        remarks = list(self.notes)
        count = int((~self.is_outage).sum())
        if 0 < count < _FEW_BURSTS:
            remarks.append(f"loss bursts: only {count}; the fits and quantiles have a weak basis")
        if len(self.bursts.length) > MOST_FITTED:
            remarks.append(f"chains are fitted to the first {MOST_FITTED} loss bursts")
        cut = ~self.bursts.complete
        if cut.any():
            remarks.append("a loss burst is cut by the beginning or end of the trace")
        if self.is_outage.any():
            remarks.append(
                "outages are reported as such: the losses in a row and the loss models do not include them"
            )
            if self.options.outage_s is None and self.models["gilbert_elliott"].test.verdict == "rejected":
                remarks.append(
                    "the fitted chain is itself rejected by its test: what counts as an outage "
                    "depends on it; --outage TIME sets the limit by hand"
                )
        return remarks

    def to_json(self) -> dict[str, object]:
        """Return all results for JSON."""
        lengths, outages = self.bursts.length, self.outage_fit
        return {
            "name": self.name,
            "packets": len(self.trace),
            "observed_s": self.observed_s,
            "deadline_s": self.options.deadline_s,
            "lost": int(self.outcomes.lost.sum()),
            "out_of_order": int(self.outcomes.out_of_order.sum()),
            "late": int(self.outcomes.late.sum()),
            "effective_losses": self.bursts.losses,
            "histogram": {str(length): count for length, count in histogram(self.bursts).items()},
            "longest": self.burst_json(int(lengths.argmax())) if len(lengths) else None,
            "outages": [*map(self.burst_json, np.flatnonzero(self.is_outage).tolist())],
            "outage_rule": self.outage_rule.reason,
            "mansd": self.longest_loss_burst,
            "mean_burst": self.mean_burst,
            "bursts_by_preferred_model": self.burst_prediction and self.burst_prediction.to_json(),
            "quantiles": [asdict(quantile) for quantile in self.quantiles],
            "fewest_deliveries_between_bursts": self.fewest_deliveries,
            "windows": {
                str(window): {"most_losses": losses.in_all, "without_outages": losses.without_outages}
                for window, losses in self.windows.items()
            },
            "delays_unknown": self.trace.delays_unknown or None,
            "losses_ambiguous": self.trace.losses_ambiguous or None,
            "delay_s": {str(share): value for share, value in self.delays.quantiles_s.items()},
            "delay_correlation": dict(
                zip(map(str, self.delays.correlation.lags), self.delays.correlation.at_lags, strict=True)
            ),
            "jitter_s": None if self.delays.jitter is None else self.delays.jitter._asdict(),
            "availability": None
            if self.service is None
            else to_json(self.service, self.observed_availability, self.predicted_availability),
            "interval_level": LEVEL,
            "models": {name: model.to_json() for name, model in self.models.items()},
            "chosen_model": self.chosen.fit.model if self.models else None,
            "outage_fit": {
                **vars(outages),
                "rate_per_s": _interval(outages.rate_per_s),
                "duration_s": _interval(outages.duration_s),
                "text": outages.text,
            },
            "remarks": self.remarks,
        }

    @property
    def fewest_deliveries(self) -> int | None:
        """Smallest number of consecutive deliveries between two bursts; None with fewer bursts."""
        deliveries = self.bursts.deliveries()[1:-1]
        return int(deliveries.min()) if len(deliveries) else None

    def burst_json(self, index: int) -> Mapping[str, float]:
        """Return a burst for JSON: losses, begin and duration."""
        begin_s, duration_s = self.bursts.times_s(self.trace)
        return {
            "losses": int(self.bursts.length[index]),
            "begin_s": float(begin_s[index]),
            "duration_s": float(duration_s[index]),
        }


def _interval(estimate: IntervalEstimate | None) -> dict[str, float] | None:
    return None if estimate is None else dict(estimate._asdict())
