"""The settings of one direction of a link: impairments, the guarantee, and the limit.

The ``correlation`` of a probability is the correlation of a latent first-order Gaussian process
between successive packets of a flow. The probability itself stays exact, unlike in ``tc netem``. At
the end are what reports and recorded packet fates use of a link; native/network/public.h declares the rest.
"""

from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass
from typing import Annotated, Self

from pydantic import Field, model_validator

from netem.core.settings_section import ScenarioSection
from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.constraints import AnyConstraint, join_guarantee, require_consistent
from netem.impairments.disciplines.maximum_error import MaximumError
from netem.impairments.feature import LossModel
from netem.impairments.kinds import AnyImpairment
from netem.impairments.kinds.blackout import Blackout
from netem.impairments.kinds.corrupt import Corrupt
from netem.impairments.kinds.delay import Delay
from netem.impairments.kinds.loss import LossOf
from netem.impairments.kinds.rate import Rate

MOST_IMPAIRMENTS = 1024
"""As native/network/link_new.c has it."""
Mansd = Annotated[int, Field(ge=0, le=1_000_000)]
USUAL_LIMIT = 16_384
"""Packets that may be delayed at once, by default: far more than loops ever have in flight."""
Constraints = Annotated[tuple[AnyConstraint, ...], Field(max_length=8)]


class LinkSettings(ScenarioSection):
    """Settings of one direction of a link; they apply to the packets of each flow."""

    impairments: tuple[AnyImpairment, ...] = ()
    """The impairments, applied in this order; at most 1024."""
    mansd: Mansd | None = None
    """At most this number of packets of a flow in a row is not effectively delivered."""
    constraints: Constraints = ()
    """Further constraints on the losses of a flow; with mansd they are the guarantee."""
    first_delivered: bool = False
    """Deliver the first packet of each flow, regardless of the impairments."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = USUAL_LIMIT
    """Maximum number of packets delayed at once; further packets are dropped."""

    @property
    def longest_delay_s(self) -> float:
        """Sum of the maximum delays, in seconds; unbounded delays count at four times the jitter.

        A rate limit counts as the transmission time of a full queue of packets of 1,500 bytes.
        """
        return sum(impairment.longest_s for impairment in self.impairments)

    @property
    def delay_is_bounded(self) -> bool:
        """Whether that is a true bound; packets that must pass a rate limit may take longer."""
        return all(impairment.is_bounded for impairment in self.impairments)

    @property
    def queues(self) -> bool:
        """Whether packets wait in a queue, for a time that depends on what else is sent."""
        return any(impairment.queues for impairment in self.impairments)

    @property
    def chooses(self) -> bool:
        """Whether the queue of a rate chooses what it sends when the link is free."""
        return any(isinstance(impairment, Rate) and impairment.scheduler for impairment in self.impairments)

    @property
    def reads_errors(self) -> bool:
        """Whether such a queue chooses by the errors that updates report."""
        return any(
            isinstance(rate, Rate) and isinstance(rate.discipline, MaximumError) for rate in self.impairments
        )

    @property
    def guarantee(self) -> LossGuarantee:
        """All rules that the losses of a flow keep; none, if nothing limits them."""
        return join_guarantee(self.mansd, self.constraints)

    @property
    def longest_burst(self) -> int | None:
        """Maximum number of consecutive losses that the guarantee allows; None: no maximum."""
        return self.guarantee.longest_burst

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (count := len(self.impairments)) > MOST_IMPAIRMENTS:
            raise ValueError(f"impairments: {count} impairments; expected at most {MOST_IMPAIRMENTS}")
        require_consistent(self.mansd, self.constraints)
        require_scores(self.impairments)
        require_order(self.impairments)
        return self


def require_scores(impairments: Iterable[AnyImpairment], loss: LossModel | None = None) -> None:
    """Check that each delay correlated with loss follows a loss model that gives a score.

    Raises:
        ValueError: there is no such loss model; the message begins with the key.
    """
    for number, impairment in enumerate(impairments):
        if isinstance(impairment, LossOf):
            loss = impairment.loss
        if getattr(impairment, "loss_correlation", 0) and not (loss and loss.gives_score):
            raise ValueError(
                f"impairments.{number}.loss_correlation: needs a loss before it, "
                "by model bernoulli or gilbert_elliott"
            )


def require_order(impairments: Sequence[AnyImpairment]) -> None:
    """Check what stands beside a rate that chooses what it sends when the link is free.

    Raises:
        ValueError: its effect would depend on the order; the message begins with the key.
    """
    rates = [(i, rate) for i, rate in enumerate(impairments) if isinstance(rate, Rate) and rate.scheduler]
    for i, rate in rates[:1]:
        for number, beside in enumerate(impairments):
            side = "before" if number < i else "after"
            fits = number == i or isinstance(beside, Corrupt)
            fits = fits or (isinstance(beside, Delay) and beside.is_constant)
            if not fits and not (side == "before" and isinstance(beside, LossOf | Blackout)):
                raise ValueError(
                    f"impairments.{number}: {beside.kind} cannot stand {side} a rate with "
                    f"{rate.discipline.kind}; losses and blackouts can stand before such a rate, "
                    "constant delays and corruption before or after it"
                )


@dataclass(slots=True)
class Counters:
    """Counts of one direction of a link: the fields of ``noack_counters``."""

    received: int = 0
    received_bytes: int = 0
    delivered: int = 0
    """Fates; see :class:`netem.core.packet_rows.Fate`."""
    dropped: int = 0
    forced: int = 0
    corrupted: int = 0
    overflowed: int = 0
    blacked_out: int = 0
    duplicated: int = 0
    held_back: int = 0
    """Held back for the guarantee."""
    forwarded: int = 0
    """Packets and copies that have left."""
    forwarded_bytes: int = 0
    delivered_out_of_order: int = 0
    """Packets that left after a later one of their flow: stale at the receiver."""
    longest_loss_burst: int = 0
    """Maximum number of consecutive losses of a flow under the present settings."""
    most_in_flight: int = 0

    def __sub__(self, earlier: "Counters") -> "Counters":
        """Return what was counted since ``earlier``; the two maxima have no meaning then."""
        pairs = zip(astuple(self), astuple(earlier), strict=True)
        return Counters(*(now - then for now, then in pairs))
