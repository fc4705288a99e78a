"""The lossy network between sensor and controller, and the acknowledgements of the baseline."""

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.impairments.constraints import guarantee_of, require_consistent
from noack.impairments.kinds import AnyImpairment
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import Constraints, LinkSettings, Mansd, require_scores
from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.lossless import NoLoss
from noack.settings.section import ScenarioSection


class AcknowledgementSection(ScenarioSection):
    """The reverse direction from controller to sensor, for the acknowledgement baseline."""

    loss: Loss = NoLoss()
    """Loss of acknowledgements."""
    mansd: Mansd | None = None
    """Largest number of consecutive lost acknowledgements; unlimited if not given."""
    constraints: Constraints = ()
    """Further constraints on the losses of acknowledgements."""
    impairments: tuple[AnyImpairment, ...] = ()
    """Further impairments of the acknowledgements, applied in this order, after the loss."""
    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """After a transmission, the sensor waits for the acknowledgement for this time before it may
    transmit again. By default five measurement periods, plus the longest delay in both
    directions."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_consistent(self.mansd, self.constraints)
        require_scores(self.impairments, self.loss)
        return self

    @property
    def link(self) -> LinkSettings:
        """The link from controller to sensor."""
        return LinkSettings(
            impairments=(LossOf(loss=self.loss), *self.impairments),
            mansd=self.mansd,
            constraints=self.constraints,
        )


class NetworkSection(ScenarioSection):
    """The lossy network between sensor and controller."""

    mansd: Mansd
    """M − 1, the maximum allowable number of successive dropouts; for the paper's M = 5 it is 4."""
    constraints: Constraints = ()
    """Further constraints on the losses of updates, e.g. at most 3 in any 10; with mansd they are
    the guarantee."""
    loss: Loss
    """Loss of updates, before the guarantee is applied."""
    impairments: tuple[AnyImpairment, ...] = ()
    """Further impairments of the updates, applied in this order, after the loss."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = 16_384
    """Largest number of delayed updates at a time; further updates are dropped."""
    enforce_mansd: bool = True
    """false: the network ignores mansd and the constraints, to show the effect of a violated
    assumption."""
    initial_sync: Literal["first_packet", "known_state"] = "first_packet"
    """How the paper's assumption of a delivered t_0 is met. first_packet: the network passes the
    first packet of a flow. known_state: sensor and controller start from x(0)."""
    protocol: Literal["none", "ack"] = "none"
    """none: updates are not acknowledged, the paper's loop. ack: the baseline for comparison; the
    controller acknowledges each update, and x_s is reset only by an acknowledgement."""
    acknowledgements: AcknowledgementSection | None = None
    """The reverse direction, for protocol = "ack"; by default without loss. It has no effect if
    protocol = "none"."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_consistent(self.mansd, self.constraints)
        require_scores(self.impairments, self.loss)
        if self.acknowledgements is not None and "protocol" not in self.model_fields_set:
            raise ValueError(
                'acknowledgements: there are none unless protocol = "ack"; '
                'say protocol = "none" to go without'
            )
        return self

    @property
    def longest_burst(self) -> int:
        """Maximum number of consecutive losses that mansd and the constraints allow together."""
        longest = self.guarantee.longest_burst
        assert longest is not None  # at most mansd
        return longest

    @property
    def reverse(self) -> AcknowledgementSection:
        """The reverse direction from controller to sensor, as given or by default."""
        return self.acknowledgements or AcknowledgementSection()

    @property
    def link(self) -> LinkSettings:
        """The link from sensor to controller."""
        return LinkSettings(
            impairments=(LossOf(loss=self.loss), *self.impairments),
            mansd=self.mansd if self.enforce_mansd else None,
            constraints=self.constraints if self.enforce_mansd else (),
            first_delivered=self.initial_sync == "first_packet",
            limit=self.limit,
        )

    @property
    def guarantee(self) -> LossGuarantee:
        """What mansd and the constraints say, also if the network does not enforce it."""
        return guarantee_of(self.mansd, self.constraints)
