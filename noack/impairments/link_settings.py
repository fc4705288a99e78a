"""What one direction of a link does: its impairments, the cap, and the limit.

A probability's ``correlation`` is that of a latent Gaussian process of order one between successive
packets of a flow, so that the probability itself stays exact (which it does not in ``tc netem``).
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from noack.impairments.feature import LossModel
from noack.impairments.kinds import AnyImpairment
from noack.impairments.kinds.loss import LossOf
from noack.settings.section import ScenarioSection

Mansd = Annotated[int, Field(ge=0, le=1_000_000)]


class LinkSettings(ScenarioSection):
    """What one direction of a link does, in this order, to the packets of each flow."""

    impairments: tuple[AnyImpairment, ...] = ()
    """Applied in this order."""
    mansd: Mansd | None = None
    """M − 1: at most so many consecutive packets of a flow are not effectively delivered."""
    first_delivered: bool = False
    """The first packet of each flow is delivered, whatever the impairments say."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = 16_384
    """At most so many packets are delayed at once; more are dropped."""

    @property
    def longest_delay_s(self) -> float:
        """Sum of the delays' upper ends, in seconds; of unbounded ones at four times the jitter.

        A rate limit counts with a full queue of packets of 1,500 bytes.
        """
        return sum(one.longest_s for one in self.impairments)

    @property
    def delay_is_bounded(self) -> bool:
        """Whether no packet takes longer; at a rate limit, packets that must pass may."""
        return all(one.is_bounded for one in self.impairments)

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_scores(self.impairments)
        return self


def require_scores(impairments: Iterable[AnyImpairment], loss: LossModel | None = None) -> None:
    """Check that before each delay that is correlated with loss there is a loss that says how bad.

    Args:
        impairments: in their order.
        loss: the loss model before them, if there is one.

    Raises:
        ValueError: there is none; the message begins with the key.
    """
    for number, impairment in enumerate(impairments):
        if isinstance(impairment, LossOf):
            loss = impairment.loss
        if getattr(impairment, "loss_correlation", 0) and not (loss and loss.gives_score):
            raise ValueError(
                f"impairments.{number}.loss_correlation: needs a loss before it, "
                "by model bernoulli or gilbert_elliott"
            )


def read_files(settings: LinkSettings, folder: Path, place: str = "") -> LinkSettings:
    """Return settings that name no files: what the files say stands in them.

    Args:
        settings: of one direction of a link.
        folder: where relative names begin.
        place: where the settings stand, for messages, e.g. ``links.toml: link.0.forward``; without
            it only the file is named.

    Raises:
        CallerError: one line; a file cannot be read, or does not contain what it should.
    """
    impairments = tuple(
        one.without_files(folder, f"{place}.impairments.{number}" if place else "")
        for number, one in enumerate(settings.impairments)
    )
    return settings.model_copy(update={"impairments": impairments})
