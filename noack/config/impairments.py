"""Settings of the network emulator: what a link does to the datagrams of one direction.

Only settings live here; the rules are netem's, one file each. A probability's ``correlation`` is
that of a latent Gaussian process of order one between successive datagrams of a flow, so that the
probability itself stays exact (which it does not in ``tc netem``).
"""

from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.settings.section import Correlation, Probability, ScenarioSection

MAX_SCRIPT = 10_000_000
MOST_DELAY_S = 3600.0
"""So that a few delays together, drawn from a Pareto distribution, fit into 64 bits of ns."""

DelayS = Annotated[FiniteFloat, Field(ge=0, le=MOST_DELAY_S)]
Mansd = Annotated[int, Field(ge=0, le=1_000_000)]
FileName = Annotated[str, Field(min_length=1)]


class NoLoss(ScenarioSection):
    """Nothing is lost."""

    model: Literal["lossless"] = "lossless"


class BernoulliLoss(ScenarioSection):
    """Each datagram is lost with a probability; independently, unless correlated."""

    model: Literal["bernoulli"] = "bernoulli"
    probability: Probability
    """Probability of loss, before the MANSD cap."""
    correlation: Correlation = 0.0
    """Between the latent variables of successive datagrams; 0 is independent loss."""


class GilbertElliottLoss(ScenarioSection):
    """Two-state Markov loss: a good and a bad state, each with its own loss probability.

    Either the probabilities of changing state, or ``mean_loss`` and ``mean_burst``.
    """

    model: Literal["gilbert_elliott"] = "gilbert_elliott"
    good_to_bad: Probability | None = None
    """Probability p of leaving the good state, per datagram."""
    bad_to_good: Probability | None = None
    """Probability r of leaving the bad state, per datagram."""
    loss_in_good: Probability = 0.0
    """Loss probability 1 − k in the good state."""
    loss_in_bad: Probability = 1.0
    """Loss probability 1 − h in the bad state."""
    mean_loss: Annotated[FiniteFloat, Field(ge=0, lt=1)] | None = None
    """Share of datagrams lost in the long run, instead of p and r."""
    mean_burst: Annotated[FiniteFloat, Field(ge=1)] | None = None
    """Mean length of a burst of losses, with mean_loss."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        chain = (self.good_to_bad, self.bad_to_good)
        means = (self.mean_loss, self.mean_burst)
        if (None in chain) == (None in means) or (None in chain and chain != (None, None)):
            raise ValueError(
                "good_to_bad: give good_to_bad and bad_to_good, or mean_loss and mean_burst"
            )
        if None in chain:
            if (self.loss_in_good, self.loss_in_bad) != (0.0, 1.0):
                raise ValueError(
                    "mean_loss: mean_loss and mean_burst go with loss_in_good 0 and loss_in_bad 1"
                )
            if self.transitions[0] > 1:
                raise ValueError(
                    "mean_burst: so much loss needs longer bursts, at least "
                    f"mean_loss/(1 − mean_loss) = {self._shortest_burst():.4g}"
                )
        elif means != (None, None):
            raise ValueError("mean_loss: goes instead of good_to_bad and bad_to_good")
        return self

    def _shortest_burst(self) -> float:
        loss = self.mean_loss or 0.0
        return loss / (1 - loss)

    @property
    def transitions(self) -> tuple[float, float]:
        """Probabilities p and r. In a Gilbert chain bursts last 1/r, and p/(p + r) is lost."""
        if self.mean_loss is not None and self.mean_burst is not None:
            return self._shortest_burst() / self.mean_burst, 1 / self.mean_burst
        return self.good_to_bad or 0.0, self.bad_to_good or 0.0


class FourStateLoss(ScenarioSection):
    """Markov loss with four states (Salsano et al., GI model; ``loss state`` of tc).

    State 1: gap, delivered. 2: delivered within a burst. 3: lost within a burst. 4: a single loss
    within a gap.
    """

    model: Literal["four_state"] = "four_state"
    p13: Probability
    """From a gap into a burst."""
    p31: Probability
    """From a burst back to a gap."""
    p32: Probability = 0.0
    """Within a burst: from lost to delivered."""
    p23: Probability = 1.0
    """Within a burst: from delivered to lost."""
    p14: Probability = 0.0
    """A single loss within a gap."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.p31 + self.p32 > 1:
            raise ValueError("p31: p31 + p32 must not exceed 1")
        if self.p13 + self.p14 > 1:
            raise ValueError("p13: p13 + p14 must not exceed 1")
        return self


class PeriodicLoss(ScenarioSection):
    """Of every ``period`` datagrams of a flow, ``burst`` in a row are lost."""

    model: Literal["periodic"] = "periodic"
    period: Annotated[int, Field(ge=1, le=2**40)]
    """Datagrams in a period."""
    burst: Annotated[int, Field(ge=0, le=2**40)] = 1
    """Losses in a period."""
    first: Annotated[int, Field(ge=0, le=2**40)] = 0
    """Number of the first datagram that is lost."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.burst > self.period:
            raise ValueError(f"burst: must not exceed the period, {self.period}")
        return self


class ScriptedLoss(ScenarioSection):
    """Exactly the named datagrams of each flow are lost, counted from 0."""

    model: Literal["scripted"] = "scripted"
    lost: Annotated[tuple[Annotated[int, Field(ge=0, lt=2**40)], ...], Field(max_length=MAX_SCRIPT)]
    """Numbers of the lost datagrams."""
    repeat_every: Annotated[int, Field(ge=0, le=2**40)] = 0
    """The script begins again after so many datagrams; 0 plays it once."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(a >= b for a, b in pairwise(self.lost)):
            raise ValueError("lost: the numbers must ascend")
        if self.repeat_every and self.lost and self.lost[-1] >= self.repeat_every:
            raise ValueError(f"repeat_every: the script is longer, up to {self.lost[-1]}")
        return self


class TraceLoss(ScenarioSection):
    """Losses from a text file: a 1 for each lost datagram, a 0 for each that is not."""

    model: Literal["trace"] = "trace"
    file: FileName
    """The file; other characters than 0 and 1 may only be white space."""
    repeat: bool = True
    """Begin again at the end; false delivers what comes after."""


class WorstCaseLoss(ScenarioSection):
    """Everything is lost that the MANSD allows to be lost."""

    model: Literal["worst_case"] = "worst_case"


Loss = Annotated[
    NoLoss
    | BernoulliLoss
    | GilbertElliottLoss
    | FourStateLoss
    | PeriodicLoss
    | ScriptedLoss
    | TraceLoss
    | WorstCaseLoss,
    Field(discriminator="model"),
]


class LossOf(ScenarioSection):
    """Loss by a model."""

    kind: Literal["loss"] = "loss"
    loss: Loss
    """The loss model."""


class Duplicate(ScenarioSection):
    """Sends a datagram twice."""

    kind: Literal["duplicate"] = "duplicate"
    probability: Probability
    """Probability of a copy."""
    correlation: Correlation = 0.0
    """Between successive datagrams."""


class Corrupt(ScenarioSection):
    """Flips one bit of the payload, at random."""

    kind: Literal["corrupt"] = "corrupt"
    probability: Probability
    """Probability of a flipped bit."""
    correlation: Correlation = 0.0
    """Between successive datagrams."""


Distribution = Literal["uniform", "normal", "pareto", "paretonormal", "empirical"]
_BOUNDED = ("uniform", "empirical")


Samples = Annotated[
    tuple[Annotated[FiniteFloat, Field(ge=-MOST_DELAY_S, le=MOST_DELAY_S)], ...],
    Field(min_length=2, max_length=1_000_000),
]


class Delay(ScenarioSection):
    """Holds a datagram back by a constant time and a random one; never by less than 0."""

    kind: Literal["delay"] = "delay"
    delay_s: DelayS = 0.0
    """The constant part (and the mean, unless times below 0 are cut)."""
    jitter_s: DelayS = 0.0
    """Of the random part: the half-width if uniform, else the standard deviation."""
    distribution: Distribution = "uniform"
    """Of the random part; paretonormal is a quarter normal, three quarters Pareto; empirical draws
    from samples_s or file."""
    samples_s: Samples | None = None
    """Observed delays, which are added to delay_s and may be below 0: drawn between them by their
    quantiles."""
    file: FileName | None = None
    """A text file of observed delays, one per line, in seconds unless it says ms or us; or a
    distribution table of tc (*.dist), which is scaled by jitter_s."""
    correlation: Correlation = 0.0
    """Between the random parts of successive datagrams of a flow."""
    loss_correlation: Annotated[FiniteFloat, Field(ge=-1, le=1)] = 0.0
    """With the loss model before it: how far a datagram in bad times is also late."""

    @property
    def longest_s(self) -> float:
        """Upper end of the delay, in seconds; four times the jitter if it has none."""
        if self.samples_s is not None:
            return self.delay_s + max(self.samples_s)
        return self.delay_s + self.jitter_s * (1 if self.distribution == "uniform" else 4)

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = (self.samples_s is not None) + (self.file is not None)
        if self.distribution == "empirical" and given != 1:
            raise ValueError("samples_s: an empirical distribution needs samples_s, or a file")
        if self.distribution != "empirical" and given:
            raise ValueError('samples_s: goes with distribution = "empirical"')
        return self


class Reorder(ScenarioSection):
    """Lets a datagram overtake: it leaves at once, however long it should be delayed."""

    kind: Literal["reorder"] = "reorder"
    probability: Probability = 1.0
    """Probability, for a datagram whose turn it is."""
    correlation: Correlation = 0.0
    """Between successive datagrams."""
    gap: Annotated[int, Field(ge=1, le=2**40)] = 1
    """It is the turn of one datagram in ``gap``."""


class Rate(ScenarioSection):
    """A bottleneck: one datagram after the other, with a finite queue before it (tail drop)."""

    kind: Literal["rate"] = "rate"
    rate_bps: Annotated[int, Field(ge=1, le=10**12)]
    """Bits per second."""
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """At most so many datagrams wait or are being sent; more are dropped."""
    overhead_bytes: Annotated[int, Field(ge=-65_535, le=65_535)] = 28
    """Added to each payload: 28 counts the headers of UDP and IPv4."""
    cell_bytes: Annotated[int, Field(ge=0, le=65_535)] = 0
    """Payload of a link-layer cell, e.g. 48; 0 has no cells."""
    cell_overhead_bytes: Annotated[int, Field(ge=0, le=1000)] = 0
    """Header of a cell, e.g. 5."""

    @property
    def longest_s(self) -> float:
        """How long a full queue of datagrams of 1,500 bytes takes, in seconds."""
        return self.queue * 8 * 1500 / self.rate_bps

    @model_validator(mode="after")
    def _check(self) -> Self:
        line_bytes = max(65_535 + self.overhead_bytes, 0)
        if self.cell_bytes:
            cells = -(-line_bytes // self.cell_bytes)
            line_bytes = cells * (self.cell_bytes + self.cell_overhead_bytes)
        # In 64 bits with a sign, the work on one datagram and the time for a full queue.
        work = line_bytes * 8 * 10**9 + self.rate_bps
        if max(work, self.queue * work // self.rate_bps) > 2**62:
            raise ValueError(
                "rate_bps: a full queue of the longest datagrams would take more than a century; "
                "more rate, a shorter queue or fewer bytes of overhead per cell"
            )
        return self


TimeS = Annotated[FiniteFloat, Field(ge=0, le=1e9)]


class Blackout(ScenarioSection):
    """Nothing comes through during intervals of time."""

    kind: Literal["blackout"] = "blackout"
    intervals_s: Annotated[tuple[tuple[TimeS, TimeS], ...], Field(min_length=1)]
    """Begin and end of each, in seconds from the emulator's start (in a run: its epoch)."""
    every_s: Annotated[FiniteFloat, Field(ge=1e-6, le=1e9)] | None = None
    """The intervals come again after so long."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        ends = [t_s for interval in self.intervals_s for t_s in interval]
        if any(a >= b for a, b in pairwise(ends)):
            raise ValueError("intervals_s: each must end after it begins, and before the next")
        if self.every_s is not None and ends[-1] > self.every_s:
            raise ValueError(f"every_s: the intervals last longer, until {ends[-1]:g} s")
        return self


Impairment = Annotated[
    LossOf | Duplicate | Corrupt | Delay | Reorder | Rate | Blackout, Field(discriminator="kind")
]


class LinkSettings(ScenarioSection):
    """What one direction of a link does, in this order, to the datagrams of each flow."""

    impairments: tuple[Impairment, ...] = ()
    """Applied in this order."""
    mansd: Mansd | None = None
    """M − 1: at most so many successive datagrams of a flow are not effectively delivered."""
    first_delivered: bool = False
    """The first datagram of each flow is delivered, whatever the impairments say."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = 16_384
    """At most so many datagrams are delayed at once; more are dropped."""

    @property
    def longest_delay_s(self) -> float:
        """Sum of the delays' upper ends, in seconds; of unbounded ones at four times the jitter.

        A rate limit counts with a full queue of datagrams of 1,500 bytes.
        """
        return sum(one.longest_s for one in self.impairments if isinstance(one, Delay | Rate))

    @property
    def delay_is_bounded(self) -> bool:
        """Whether nothing takes longer than that; at a rate limit, datagrams that must pass may."""
        return not any(
            isinstance(one, Rate)
            or (isinstance(one, Delay) and one.jitter_s and one.distribution not in _BOUNDED)
            for one in self.impairments
        )

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_scores(self.impairments)
        return self


def require_scores(impairments: Iterable[Impairment], loss: Loss | None = None) -> None:
    """Check that before each delay that is correlated with loss there is a loss to tell it.

    Args:
        impairments: in their order.
        loss: the loss model before them, if there is one.

    Raises:
        ValueError: there is none; the message begins with the key.
    """
    for number, impairment in enumerate(impairments):
        if isinstance(impairment, LossOf):
            loss = impairment.loss
        tells = isinstance(loss, BernoulliLoss | GilbertElliottLoss)
        if isinstance(impairment, Delay) and impairment.loss_correlation and not tells:
            raise ValueError(
                f"impairments.{number}.loss_correlation: needs a loss before it, "
                "by model bernoulli or gilbert_elliott"
            )
