"""What a certificate assumes of the network, what it bounds, and the constants that it states."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee, LossRule
from noack.theory.error_gains import ErrorGains
from noack.theory.error_growth import TriggerBound
from noack.theory.plant_gains import PlantGains


class NetworkConditions(NamedTuple):
    """The assumptions of a certificate about network and schedule, in the plant's time."""

    dropouts: int
    """The largest number of consecutive losses: M − 1, or less by further constraints."""
    sampling_s: float = 0.0
    """h, the longest time between two tests of the trigger; 0 is a continuous trigger."""
    spacing_s: float = 0.0
    """The shortest time between two tests; all other times between tests are multiples of it."""
    delay_s: float = 0.0
    """d, the longest time from an event until a delivered update affects the plant's input."""
    hold_s: float = 0.0
    """σ, the largest difference between the time and the model time of the applied input."""
    start_s: float = 0.0
    """Time from which the plant applies the controller's input; before, its input is 0."""
    constraints: tuple[LossRule, ...] = ()
    """Further rules of the guarantee."""

    @property
    def guarantee(self) -> LossGuarantee:
        """All rules that the network keeps."""
        return LossGuarantee((LongestBurst(self.dropouts), *self.constraints))


class Constants(NamedTuple):
    """The constants of a certificate; ‖·‖_W is the trigger's norm, ‖·‖ the Euclidean."""

    rate_per_s: float
    """Every bound decays like e^{−rate·t}."""
    missing_events: int
    """N, the largest number of events whose updates the controller does not have."""
    delta: float
    """Δ: ‖e_c‖_W ≤ Δβe^{−αt}."""
    overshoot: float
    """β̃/β: ‖e_s‖_W ≤ β̃e^{−αt}."""
    input_error: float
    """π: ‖u − Kx‖ ≤ πe^{−αt}, from the first applied input of the controller on."""
    start_error: float
    """The same before the first applied input, when u = 0."""
    state: float
    """X: ‖x‖ ≤ Xe^{−αt}."""
    state_weighted: float
    """X_W: ‖x‖_W ≤ X_W e^{−αt}."""
    mismatch: float
    """‖E x‖_W ≤ mismatch · e^{−αt}: the rate at which the model deviates from the plant."""
    inter_event_s: float | None
    """δ, lower bound of the inter-event time; None if there is no such bound."""
    loop_gain: float
    """Loop gain of the errors (small-gain condition); below 1."""
    estimation_error: float = 0.0
    """‖x̂ − x‖_W at the measurements. Where it is not 0, e_s and e_c are x_s − x̂ and x_c − x̂."""
    received_input_error: float = 0.0
    """The same as π while the controller has every update: ‖KW^{−1}‖β̃ + q."""


class VoidError(ArithmeticError):
    """There is no certificate; the message has the reason."""

    def __init__(self, reason: str, loop_gain: float = math.inf) -> None:
        super().__init__(reason)
        self.loop_gain = loop_gain


class EstimationBound(NamedTuple):
    """Bound of the estimation error at every measurement, where the trigger tests x̂ instead of x.

    ‖x̂ − x‖_W ≤ fixed + Σ_C share_C sup‖C x‖ + from_input sup‖p‖
    """

    fixed: float = 0.0
    """From noise, disturbances and the first estimate."""
    shares: Mapping[str, float] = MappingProxyType({})
    """share_C by the name of C in :attr:`PlantGains.outputs`: the plant is not the model."""
    from_input: float = 0.0


MEASURED = EstimationBound()
"""The trigger tests the measurements: there is no estimation error."""


class Part(NamedTuple):
    """One of several bounds that are added: with its own decay rate and its own causes."""

    error: ErrorGains
    plant: PlantGains
    bound: TriggerBound
    estimation: EstimationBound = MEASURED
