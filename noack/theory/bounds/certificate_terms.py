"""The terms of a certificate: conditions, bounds by trigger and observer, constants."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from noack.guarantee.loss_guarantee import LongestBurst, LossGuarantee, LossRule
from noack.theory.bounds.gains import ErrorGains, PlantGains


class NetworkConditions(NamedTuple):
    """The assumptions of a certificate about network and schedule, in the plant's time.

    They are not a schedule, but what may happen at most under one with delays and lateness: bounds, in
    seconds, which searches scale (:func:`noack.theory.certificates.conditions.nominal_conditions`).
    """

    dropouts: int
    """The largest number of consecutive losses: M − 1, or less by further constraints."""
    sampling_s: float = 0.0
    """h, the longest time between two tests of the trigger; 0 is a continuous trigger."""
    spacing_s: float = 0.0
    """The shortest time between two tests; all other times between tests are multiples of it. 0: tests
    are at any times, at least ``apart_s`` apart."""
    delay_s: float = 0.0
    """d, the longest time from an event until a delivered update affects the plant's input."""
    hold_s: float = 0.0
    """σ, the largest difference between the time and the model time of the applied input."""
    start_s: float = 0.0
    """Time from which the plant applies the controller's input; before, its input is 0."""
    constraints: tuple[LossRule, ...] = ()
    """Further rules of the guarantee."""
    apart_s: float = 0.0
    """The shortest time between two tests that are on no grid."""

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
    """(β̃ + η)/β: ‖x_s − x̂‖_W ≤ (β̃ + η)e^{−αt}. With x̂ = x: ‖e_s‖_W ≤ β̃e^{−αt}."""
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
    """Loop gain of the errors (small-gain condition); below 1, and 0 where the bounds need none."""
    estimation_error: float = 0.0
    """η: ‖x̂ − x‖_W ≤ ηe^{−αt} at the measurements. Where it is not 0, Δ is of x_c − x̂."""
    received_input_error: float = 0.0
    """The same as π while the controller has every update: ‖KW^{−1}‖β̃ + q."""
    present_input_error: float = 0.0
    """A bound of ‖K e_s‖ + q at all times: the part of π that does not come from missing events."""


class NoCertificateError(ArithmeticError):
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


class InterEventTimes(NamedTuple):
    """Bounds of the time between two events that a trigger guarantees, whatever happens to e_s."""

    shortest_s: float = 0.0
    longest_s: float = math.inf
    earliest_due_s: float = math.inf
    """The earliest time after an event at which the next one may be due without any e_s; before
    :attr:`longest_s` where tests may be missing."""


class TriggerBound(NamedTuple):
    """Bounds of e_s that a trigger guarantees, scaled.

    After each of its tests ‖e_s‖_W ≤ β + Σ_C share_C sup‖C x‖.
    """

    beta: float
    """β, in the units of ‖W x‖."""
    least_event_error: float | None
    """The smallest ‖e_s‖_W at an event; None if it may be arbitrarily small."""
    shares: Mapping[str, float] = MappingProxyType({})
    """share_C by the name of C in :attr:`PlantGains.outputs`."""
    untested_s: float = 0.0
    """After an event the trigger is not tested for this time: e_s grows from 0 for up to h more."""
    merges_growths: bool = False
    """Whether the growth without a test is bounded as after one, for the longest time of both."""
    is_tested: bool = True
    """Whether there is a test at all; without one, only the time since the event bounds e_s."""
    window_s: float = 0.0
    """The bound is that of ‖e_s‖_W at some time up to this long before the test. An event comes no
    earlier than this after the last one, unless ‖e_s‖_W has exceeded ``least_event_error``."""
    is_mean: bool = False
    """Whether it also bounds the mean of ‖e_s‖_W over that time, or that since the event."""
    root_output: str = ""
    """A C of the shares for which (β² + sup‖C x‖²)^½ may take the place of β + share_C sup‖C x‖."""
    times: InterEventTimes = InterEventTimes()
    further: tuple["TriggerBound", ...] = ()
    """Further bounds that hold at the same time; only their e_s is used, not their times."""
    unit: float | None = None
    """Unit of the constants Δ and β̃/β; by default β."""

    @property
    def all_bounds(self) -> tuple["TriggerBound", ...]:
        """This bound and the further ones."""
        return (self, *self.further)


class CertificatePart(NamedTuple):
    """One of several bounds that are added: with its own decay rate and its own inputs."""

    error: ErrorGains
    plant: PlantGains
    bound: TriggerBound
    estimation: EstimationBound = MEASURED
