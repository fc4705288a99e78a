"""Certified bounds over time, under their conditions and assumptions.

:class:`ScenarioCertificate` has the bounds from the start of the run on. :class:`KnownStateBounds`
are sharper ones from the newest event on, at which the sensor knows x. With M = A + BK and the
input error p = u − Kx, for every t from the event t_k on

    ‖x(t) − e^{M(t−t_k)} x(t_k)‖ ≤ ∫ ‖e^{Ms} B U‖ ‖p(t−s)‖ ds,    0 ≤ s ≤ t − t_k.

The certificate bounds ‖p‖ by πe^{−αt}. Where j events are missing at the controller, p is smaller:

    ‖C e_c‖ ≤ (‖C W⁻¹‖ + Σ_{i<j} sup_{τ≥iδ} ‖C e^{(H+αI)τ} W⁻¹‖) β̃ = D_{C,j} β̃
    ‖p‖     ≤ D_{K,j} β̃ + q

scaled by e^{αt}. From d after the event until the next one, j is the number of events after the
newest one that the controller has received. All integrals are tabulated once for a certificate.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, Self

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.core.number_format import at_least, at_most
from noack.plants.systems.enclosed_motion import Inclusion
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import Constants, NetworkConditions
from noack.theory.bounds.disturbances import bound_forcing
from noack.theory.bounds.enclosure import KernelBounds, response
from noack.theory.bounds.gains import Counts, Output, PlantGains, error_gains
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus
from noack.theory.certificates.conditions import BOX, LINEAR_EQUATIONS, OWN_PLANT
from noack.theory.certificates.proven_bounds import ProvenBounds

Constant = Literal["delta", "overshoot", "state", "estimation_error"]
"""A constant that bounds an output; :class:`Constants` has all."""
_OUTPUTS: Mapping[Constant, str] = {"delta": "e_c", "overshoot": "e_s", "state": "x"}
"""The outputs of proven bounds."""
LONGEST_S, _TIME_ACCURACY = 1e7, 1e-6
"""The longest run, and the relative accuracy of the time at which a bound is small enough."""
_CLEARLY_SMALLER = 0.95
"""A bound is worth a mention beside another one below this share of it."""
_IN_LEVELS = ("delta", "overshoot")
"""Constants in units of the threshold."""


class Region(NamedTuple):
    """The region that a nonlinear plant does not leave, and the box that encloses it there."""

    x: tuple[float, ...]
    """Bounds of |x_j|."""
    u: tuple[float, ...]
    """Bounds of |u_i|."""
    A: tuple[tuple[float, ...], ...]
    """Centre of the box."""
    B: tuple[tuple[float, ...], ...]
    halfwidth_A: tuple[tuple[float, ...], ...]
    halfwidth_B: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, halfwidths: Vector, box: Inclusion) -> Self:
        """Return the region |(x, u)_j| ≤ ``halfwidths``, (n + m,), with its box."""
        n = len(box.A)
        rows = (tuple(map(tuple, matrix.tolist())) for matrix in box)
        return cls(tuple(halfwidths[:n].tolist()), tuple(halfwidths[n:].tolist()), *rows)


@dataclass(frozen=True)
class ScenarioCertificate:
    """The guaranteed bounds of a loop."""

    scope: str
    """The plants that it covers."""
    beta: float
    """β, or 0 if the threshold has no such part."""
    alpha_per_s: float
    floor: float
    """ε: the constant part of the threshold, or 0."""
    weighted: bool
    """Whether the trigger's norm is weighted."""
    conditions: NetworkConditions
    assumptions: tuple[Assumption, ...]
    constants: Constants | None
    """None if there is no certificate."""
    floor_constants: Constants | None
    """The constants from ``floor_from_s`` on, with ε in place of βe^{−αt} and without decay."""
    void: str | None
    """Reason for having no certificate; None if there is one."""
    persistent_constants: Constants | None = None
    """The constants, in units of 1 and without decay, whose bounds are added to those of
    ``constants`` under disturbances, noise, an observer or a constant threshold."""
    other: "ScenarioCertificate | None" = None
    """A second certificate of the same plants under the same conditions: both bounds hold."""
    region: Region | None = None
    """Of a nonlinear plant: where the certificate holds, and what x and u do not leave."""
    proven: ProvenBounds | None = None
    """The bounds that the checker has proven. They take the place of those by ``constants``, which are
    computed and not checked."""

    @property
    def exists(self) -> bool:
        """Whether there is a certificate."""
        return self.constants is not None or self.proven is not None

    def with_proof(self, proven: ProvenBounds | None) -> Self:
        """Return the certificate with bounds that were proven, also where none could be computed."""
        assumptions = self.assumptions
        if proven is not None and self.constants is None:
            assumptions = tuple(
                each._replace(verdict=AssumptionStatus.NOT_NEEDED, why="the bounds are proven without it")
                if each.verdict is AssumptionStatus.VIOLATED
                else each
                for each in assumptions
            )
        return replace(self, proven=proven, assumptions=assumptions)

    def of_output(self, index: int, row: Sequence[float]) -> Self:
        """Return the certificate with the bound of an output, |c x|, in the place of that of ‖x‖.

        It is the output's own, if one is proven, or else ‖c‖ times that of ‖x‖.

        Args:
            index: the output's place among those of the loop.
            row: its row c, n factors.
        """
        size = math.nextafter(math.hypot(*row) * (1 + 4 * np.finfo(float).eps), math.inf)
        return self._of_output(f"y[{index}]", size)

    def _of_output(self, name: str, size: float) -> Self:
        def scaled(constants: Constants | None) -> Constants | None:
            return None if constants is None else constants._replace(state=size * constants.state)

        proven = self.proven
        return replace(
            self,
            constants=scaled(self.constants),
            floor_constants=scaled(self.floor_constants),
            persistent_constants=scaled(self.persistent_constants),
            other=None if self.other is None else self.other._of_output(name, size),
            proven=None if proven is None else proven.of_output(name, size),
        )

    @property
    def ultimate_state(self) -> float:
        """What the bound of ‖x‖, or of the output, tends to as t → ∞; NaN without a certificate."""
        reached = float(self.state(np.array([LONGEST_S]))[0])
        limit = math.inf if self.proven is None else self.proven.limits.get("x", math.inf)
        return min(reached, limit)

    @property
    def is_smaller_in_limit(self) -> bool:
        """Whether a smaller bound is proven for t → ∞ than the one from the start on tends to."""
        return self.ultimate_state < _CLEARLY_SMALLER * float(self.state(np.array([LONGEST_S]))[0])

    def settles_s(self, allowed: float) -> float | None:
        """Return from when on ‖x‖, or the output, is at most a value; None: it may exceed it for ever."""

        def within(t_s: float) -> bool:
            after_s = max(t_s, self.floor_from_s) if math.isfinite(self.floor_from_s) else t_s
            return bool((self.state(np.array([t_s, after_s])) <= allowed).all())

        if not within(LONGEST_S):
            return None
        if within(0.0):
            return 0.0
        low_s, high_s = 0.0, LONGEST_S
        while high_s - low_s > _TIME_ACCURACY * high_s:
            middle_s = (low_s + high_s) / 2
            low_s, high_s = (low_s, middle_s) if within(middle_s) else (middle_s, high_s)
        return high_s

    def is_proven(self, constant: Constant) -> bool:
        """Whether the bound with this constant is a proven one."""
        return self.proven is not None and _OUTPUTS.get(constant) in self.proven.bounds

    def first(self, constant: Constant) -> float | None:
        """The first number in a bound, see :func:`envelope_formula`; None if there is no such bound."""
        if self.proven is not None and self.is_proven(constant):
            return self.proven.bounds[_OUTPUTS[constant]].first
        return None if self.constants is None else float(getattr(self.constants, constant))

    @property
    def source(self) -> str:
        """Name of the certificate as the source of a claim."""
        kinds = {OWN_PLANT: "certificate", LINEAR_EQUATIONS: "certificate", BOX: "box certificate"}
        return kinds.get(self.scope, "region certificate")

    @property
    def floor_from_s(self) -> float:
        """Time at which βe^{−αt} falls below the floor ε; infinite without a floor."""
        return floor_from_s(self.beta, self.alpha_per_s, self.floor)

    @property
    def inter_event_s(self) -> float | None:
        """Lower bound of the inter-event time; None if there is none. See :meth:`apart_s`."""
        if self.has_proven_inter_event_time:
            assert self.proven is not None
            return self.proven.inter_event_s
        times_s = [c.inter_event_s for c in (self.constants, self.floor_constants) if c is not None]
        known = [value for value in times_s if value is not None]
        return min(known) if known and len(known) == len(times_s) else None

    @property
    def has_proven_inter_event_time(self) -> bool:
        """Whether the inter-event time is a proven one."""
        return self.proven is not None and self.proven.inter_event_s is not None

    def apart_s(self, events_s: Vector, started_s: float) -> Vector:
        """Return how far after each event the next one is at least, (k,); 0 where nothing is known.

        Args:
            events_s: times of the events, (k,); the first one is at 0.
            started_s: when the first input acts.
        """
        if self.proven is not None and self.has_proven_inter_event_time:
            return self.proven.apart_s(events_s, started_s)
        return np.full(len(events_s), self.inter_event_s or 0.0)

    @property
    def unit(self) -> str:
        """The unit of Δ and β̃: β or ε; empty for 1."""
        if self.beta > 0 and self.beta >= self.floor:
            return "β"
        is_added = self.persistent_constants is not None
        decays = self.constants is not None and self.constants.rate_per_s > 0
        return "ε" if self.floor > 0 and not is_added and not decays else ""

    @property
    def level(self) -> str:
        """The unit of the error bounds at all times: βe^{−αt}; without decay β or ε."""
        rate = 0.0 if self.constants is None else self.constants.rate_per_s
        return f"{self.unit}e^(−{at_least(rate, 3)}t)" if rate else self.unit

    def sensor_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖e_s‖_W at times (k,); NaN without a certificate."""
        return self._envelope(t_s, "overshoot")

    def controller_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖e_c‖_W at times (k,); NaN without a certificate."""
        return self._envelope(t_s, "delta")

    def state(self, t_s: Matrix) -> Matrix:
        """Bound of ‖x‖ at times (k,); NaN without a certificate."""
        return self._envelope(t_s, "state")

    def estimation_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖x̂ − x‖_W at measurements (k,); NaN without a certificate."""
        return self._envelope(t_s, "estimation_error")

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        constants, floor, persistent = self.constants, self.floor_constants, self.persistent_constants
        return asdict(self) | {
            "conditions": self.conditions._asdict()
            | {"constraints": [rule.name for rule in self.conditions.constraints]},
            "assumptions": [assumption._asdict() for assumption in self.assumptions],
            "constants": None if constants is None else constants._asdict(),
            "floor_constants": None if floor is None else floor._asdict(),
            "persistent_constants": None if persistent is None else persistent._asdict(),
            "other": None if self.other is None else self.other.to_json(),
            "inter_event_s": self.inter_event_s,
            "floor_from_s": None if self.floor == 0 else self.floor_from_s,
            "region": None if self.region is None else self.region._asdict(),
            "proven": None if self.proven is None else self.proven.to_json(),
        }

    def _envelope(self, t_s: Matrix, constant: Constant) -> Matrix:
        if self.proven is not None and self.is_proven(constant):
            return self.proven.at(_OUTPUTS[constant], np.asarray(t_s, dtype=float))
        return self._computed(np.asarray(t_s, dtype=float), constant)

    def _computed(self, t_s: Matrix, constant: Constant) -> Matrix:
        if self.constants is None:
            return np.full(len(t_s), np.nan)

        def scale(constants: Constants, level: float) -> float:
            value = float(getattr(constants, constant))
            return value * level if constant in _IN_LEVELS else value

        level = max(self.beta, self.floor if self.constants.rate_per_s == 0 else 0.0)
        bound = scale(self.constants, level or 1.0) * np.exp(-self.constants.rate_per_s * t_s)
        if self.floor_constants is not None:
            late = scale(self.floor_constants, self.floor)
            bound = np.where(t_s < self.floor_from_s, bound, late)
        if self.persistent_constants is not None:
            bound = bound + scale(self.persistent_constants, 1.0)
        if self.other is not None:
            bound = np.minimum(bound, self.other._computed(t_s, constant))
        return np.asarray(bound)


def floor_from_s(beta: float, alpha_per_s: float, floor: float) -> float:
    """Return the time at which βe^{−αt} falls below the floor; infinite without a floor."""
    if floor == 0:
        return math.inf
    return math.log(beta / floor) / alpha_per_s if beta > floor else 0.0


def envelope_formula(quantity: str, certificate: ScenarioCertificate, constant: Constant) -> str:
    """Return a certificate's bound of a quantity; ``{}`` stands for its first constant."""
    if certificate.proven is not None and certificate.is_proven(constant):
        return certificate.proven.formula(quantity, _OUTPUTS[constant])
    in_levels = constant in _IN_LEVELS
    parts: list[str] = []
    present: ScenarioCertificate | None = certificate
    while present is not None and present.constants is not None:
        rate = present.constants.rate_per_s
        decay = f"e^(−{at_least(rate, 3)}t)" if rate else ""
        formula = at_most(getattr(present.constants, constant)) if parts else "{}"
        formula += f" {level}" if (level := present.level if in_levels else decay) else ""
        if (late := present.floor_constants) is not None:
            unit = " ε" if in_levels else ""
            formula += (
                f", from {at_most(present.floor_from_s)} s on ≤ {at_most(getattr(late, constant))}{unit}"
            )
        if (persistent := present.persistent_constants) is not None:
            formula += f" + {at_most(getattr(persistent, constant))}"
        parts.append(formula)
        present = present.other
    return f"{quantity} ≤ {' and ≤ '.join(parts)}"


@dataclass(frozen=True)
class KnownStatePart:
    """The part that decays, or the one that persists: its constants, with the gains for their rate."""

    plant: PlantGains
    constants: Constants
    unit: float
    """The unit of Δ and of β̃ in the constants."""
    floor_share: float = 0.0
    """ε/β: the bounds decay to this share of themselves."""

    @cached_property
    def _forced(self) -> KernelBounds:
        return self.plant.forced[Output.STATE]

    @cached_property
    def _estimated(self) -> KernelBounds:
        responses = response(self.plant.closed_loop, self.plant.error.inverse_weight)
        return responses.through(np.eye(len(self.plant.A)))

    def level(self, t_s: Vector) -> Vector:
        """Return what the scaled bounds are multiplied with, (k,)."""
        decayed = np.exp(-self.constants.rate_per_s * t_s)
        return np.asarray(np.maximum(decayed, self.floor_share))

    @property
    def controller_errors(self) -> tuple[Vector, float]:
        """Scaled bounds of ‖e_c‖_W by the number of missing events, and one for any number."""
        constants = self.constants
        return self._by_missing(Output.WEIGHTED, self._event_error), constants.delta * self.unit

    @property
    def input_errors(self) -> tuple[Vector, float]:
        """Scaled bounds of ‖u − Kx‖ by the number of missing events, and one for any number."""
        constants = self.constants
        by_missing = self._by_missing(Output.GAIN, constants.present_input_error)
        by_missing[0] = constants.received_input_error
        return by_missing, max(constants.input_error, constants.start_error)

    @property
    def _event_error(self) -> float:
        """β̃ + η, the largest x_s − x̂ at an event, scaled."""
        return self.constants.overshoot * self.unit

    def _by_missing(self, output: Output, by_received: float) -> Vector:
        """Return ``by_received`` + Σ_{i<j} sup_{τ≥iδ} ‖C e^{(H+αI)τ} W^{−1}‖ (β̃ + η) for each j."""
        error, missing_events = self.plant.error, self.constants.missing_events
        if not error.decays:
            return np.array([by_received])
        ages_s = (self.constants.inter_event_s or 0.0) * np.arange(missing_events, dtype=np.float64)
        sums = np.append(0.0, np.cumsum(error.kernels[output].sups(ages_s)))
        return np.asarray(by_received + sums * self._event_error)

    def deviation(self, input_errors: Vector, age_s: Vector, missing: Counts, delay_s: float) -> Vector:
        """Return the scaled bound of the deviation from the prediction, (k,)."""
        known, forced = _entries(input_errors, missing), self._forced
        whole = forced.integral_until(age_s)
        # In the time d after the event, updates before it may be in flight.
        latest = np.minimum(age_s, delay_s) * forced.sups(np.maximum(age_s - delay_s, 0.0))
        deviation = known * whole + (input_errors[-1] - known) * np.minimum(latest, whole)
        if self.constants.estimation_error:
            deviation = deviation + self.constants.estimation_error * self._estimated.sups(age_s)
        return np.asarray(deviation)


@dataclass(frozen=True)
class KnownStateBounds:
    """The bounds of a run from its newest event on, under the conditions of a certificate."""

    parts: tuple[KnownStatePart, ...]
    """Their bounds are added."""
    delay_s: float
    disturbances: Matrix
    """Columns D_i of disturbances, with the largest value of each, (n, k)."""
    other: "KnownStateBounds | None" = None
    """Those of a second certificate, which hold, too."""

    def state_deviation(self, t_s: Vector, age_s: Vector, missing: Counts) -> Vector:
        """Bound ‖x(t) − e^{M(t−t_k)} x(t_k)‖ at times t, (k,).

        Args:
            t_s: t, (k,).
            age_s: t − t_k, the time since the newest event, (k,).
            missing: number of events after the newest one that the controller has received, (k,).
        """
        sizes = [
            part.level(t_s) * part.deviation(errors, age_s, missing, self.delay_s)
            for part, errors in zip(self.parts, self._input_errors, strict=True)
        ]
        bound = np.asarray(sum(sizes) + self._disturbed(age_s))
        if self.other is None:
            return bound
        return np.asarray(np.minimum(bound, self.other.state_deviation(t_s, age_s, missing)))

    def controller_error(self, t_s: Vector, missing: Counts) -> Vector:
        """Bound ‖e_c‖_W at times t, (k,), given the numbers of missing events."""
        sizes = [
            part.level(t_s) * _entries(errors, missing)
            for part, errors in zip(self.parts, self._controller_errors, strict=True)
        ]
        bound = np.asarray(sum(sizes))
        if self.other is None:
            return bound
        return np.asarray(np.minimum(bound, self.other.controller_error(t_s, missing)))

    @cached_property
    def _controller_errors(self) -> list[Vector]:
        return _together([part.controller_errors for part in self.parts])

    @cached_property
    def _input_errors(self) -> list[Vector]:
        return _together([part.input_errors for part in self.parts])

    def _disturbed(self, age_s: Vector) -> Vector:
        if not self.disturbances.size:
            return np.zeros(len(age_s))
        edges_s, sums = self._disturbance_sums
        return np.asarray(sums[np.searchsorted(edges_s, age_s, side="left")])

    @cached_property
    def _disturbance_sums(self) -> tuple[Vector, Vector]:
        """Nodes, and Σ_i ∫‖e^{Ms} D_i‖ds up to each node and over all times."""
        plant, total = self.parts[-1].plant, 0.0
        unscaled = plant.closed_loop - plant.alpha_per_s * np.eye(len(plant.A))
        responses = response(unscaled, self.disturbances)
        identity = np.eye(len(plant.A))
        for column in self.disturbances.T:
            total += float(response(unscaled, column[:, None]).through(identity).integral())
        sums = np.append(0.0, np.cumsum(responses.areas_of_columns(identity)))
        return responses.edges_s, np.append(sums, max(total, float(sums[-1])))


def _together(parts: Sequence[tuple[Vector, float]]) -> list[Vector]:
    """Return each part's bounds by the number of missing events; the last holds for any number.

    For each number all parts take the bound that is made for it, or all the one for any number:
    bounds of parts may be added only if they bound the signal in the same way.
    """
    count = min(len(by_missing) for by_missing, _ in parts)
    is_smaller = np.all([by_missing[:count] <= for_any for by_missing, for_any in parts], axis=0)
    return [
        np.append(np.where(is_smaller, by_missing[:count], for_any), for_any) for by_missing, for_any in parts
    ]


def _entries(table: Vector, missing: Counts) -> Vector:
    return np.asarray(table[np.clip(missing, 0, len(table) - 1)])


def known_state_bounds(resolved: Scenario, certificate: ScenarioCertificate) -> KnownStateBounds | None:
    """Return the bounds from the newest event; None without a certificate, or for a box."""
    decaying, floor, persistent = (
        certificate.constants,
        certificate.floor_constants,
        certificate.persistent_constants,
    )
    if decaying is None or certificate.scope != OWN_PLANT:
        return None
    loop = loop_of(resolved)

    def part(constants: Constants, unit: float, floor_share: float = 0.0) -> KnownStatePart:
        rate = constants.rate_per_s
        error = error_gains(loop, rate)
        plant = PlantGains(error, loop.A, loop.B, loop.x0[:, None], rate)
        return KnownStatePart(plant, constants, unit, floor_share)

    level = max(certificate.beta, certificate.floor if decaying.rate_per_s == 0 else 0.0)
    parts = [part(decaying, level or 1.0, 0.0 if floor is None else certificate.floor / level)]
    parts += [] if persistent is None else [part(persistent, 1.0)]
    forcing = bound_forcing(resolved, loop.B)
    increments = np.zeros((loop.n, 0)) if forcing is None else forcing.limited
    return KnownStateBounds(
        tuple(parts),
        certificate.conditions.delay_s,
        increments,
        None if certificate.other is None else known_state_bounds(resolved, certificate.other),
    )
