"""The lossy network: the updates' direction, and that of acknowledgements or actuations."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.impairments.constraints import join_guarantee, require_consistent
from noack.impairments.kinds import AnyImpairment
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import Constraints, LinkSettings, Mansd, require_scores
from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.lossless import NoLoss
from noack.protocol.wire_format import Flow
from noack.settings.section import ScenarioSection


class DirectionSection(ScenarioSection):
    """A direction of the network: what happens to its packets, and the guarantee."""

    loss: Loss = NoLoss.model_construct()
    """Loss of packets, before the guarantee is applied."""
    mansd: Mansd | None = None
    """Largest number of consecutive lost packets; unlimited if not given."""
    constraints: Constraints = ()
    """Further constraints on the losses, e.g. at most 3 in any 10; with mansd they are the
    guarantee."""
    impairments: tuple[AnyImpairment, ...] = ()
    """Further impairments, applied in this order, after the loss."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = 16_384
    """Largest number of delayed packets at a time; further packets are dropped."""

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        require_consistent(self.mansd, self.constraints)
        require_scores(self.impairments, self.loss)
        return self

    @property
    def link(self) -> LinkSettings:
        """The link of this direction."""
        return LinkSettings(
            impairments=(LossOf(loss=self.loss), *self.impairments),
            mansd=self.mansd,
            constraints=self.constraints,
            limit=self.limit,
        )


class AcknowledgementSection(DirectionSection):
    """The direction from controller to sensor, for the acknowledgement baseline."""

    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """After a transmission, the sensor waits for the acknowledgement for this time before it may
    transmit again. By default five measurement periods, plus the longest delay in both
    directions."""


class ActuationSection(DirectionSection):
    """The direction from controller to plant, if actuations cross the network too."""


class NetworkSection(DirectionSection):
    """The lossy network between sensor and controller."""

    mansd: Mansd
    """M − 1, the maximum allowable number of successive dropouts; for the paper's M = 5 it is 4."""
    loss: Loss
    """Loss of updates, before the guarantee is applied."""
    enforce_mansd: bool = True
    """false: the network ignores mansd and the constraints, to show the effect of a violated
    assumption."""
    initial_sync: Literal["first_packet", "known_state"] = "first_packet"
    """How the paper's assumption of a delivered t_0 is met. first_packet: the network passes the
    first packet of a flow. known_state: sensor and controller start from x(0)."""
    protocol: Literal["none", "ack"] = "none"
    """none: updates are not acknowledged, the paper's loop. ack: the baseline for comparison; the
    controller acknowledges each update, and x_s is reset only by an acknowledgement."""
    encrypted: bool = False
    """Live, the processes encrypt the vectors of their datagrams (ChaCha20-Poly1305)."""
    acknowledgements: AcknowledgementSection | None = None
    """The direction from controller to sensor, for protocol = "ack"; by default without loss.
    It has no effect if protocol = "none"."""
    actuation: ActuationSection | None = None
    """The direction from controller to plant; by default the controller sends its actuations to
    the plant directly, without loss or delay."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.acknowledgements is not None and "protocol" not in self.model_fields_set:
            raise ValueError(
                'acknowledgements: there are none unless protocol = "ack"; '
                'say protocol = "none" to go without'
            )
        if self.actuation is not None and self.protocol == "ack":
            raise ValueError('actuation: not with protocol = "ack"')
        return self

    @property
    def flows(self) -> tuple[Flow, ...]:
        """What crosses the network; the place of a flow here is the number of its direction."""
        if self.protocol == "ack":
            return Flow.UPDATE, Flow.ACKNOWLEDGEMENT
        return (Flow.UPDATE,) if self.actuation is None else (Flow.UPDATE, Flow.ACTUATION)

    def link_of(self, flow: Flow) -> LinkSettings:
        """The link of a flow that crosses the network."""
        if flow is Flow.UPDATE:
            return self.link
        return (self.actuation or self.reverse).link

    @property
    def longest_burst(self) -> int:
        """Maximum number of consecutive losses that mansd and the constraints allow together."""
        longest = self.guarantee.longest_burst
        assert longest is not None  # at most mansd
        return longest

    @property
    def directions(self) -> Mapping[str, DirectionSection]:
        """The tables of the directions that are given, by their keys in the scenario."""
        given = {"": self, ".acknowledgements": self.acknowledgements, ".actuation": self.actuation}
        return {f"network{key}": one for key, one in given.items() if one is not None}

    @property
    def reverse(self) -> AcknowledgementSection:
        """The direction of the acknowledgements, as given or by default."""
        return self.acknowledgements or AcknowledgementSection()

    @property
    def link(self) -> LinkSettings:
        """The link from sensor to controller."""
        update: dict[str, Any] = {"first_delivered": self.initial_sync == "first_packet"}
        if not self.enforce_mansd:
            update |= {"mansd": None, "constraints": ()}
        return super().link.model_copy(update=update)

    @property
    def guarantee(self) -> LossGuarantee:
        """What mansd and the constraints say, also if the network does not enforce it."""
        return join_guarantee(self.mansd, self.constraints)
