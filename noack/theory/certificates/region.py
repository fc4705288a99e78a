"""Certificates of a nonlinear plant on a region that it is proven not to leave.

Over the region |x_j| ≤ r_j, |u_i| ≤ r_{n+i} the plant's equations are enclosed: they are A x + B u
with some A and B of a box, which may change at any time (:mod:`enclosed_motion
<noack.plants.systems.enclosed_motion>`). As long as x and u are in the region, the bounds of the
box hold. If they are below r, x and u never leave it: a first exit would contradict them
(docs/derivations.md, "Beyond linear plants").

The bounds increase with the region. So the search starts with a small one, and takes a little more
than the bounds that follow from it as the next, until a region's bounds are inside it. It tends to
the smallest such region, which has the tightest bounds. If the bounds lose their loop gain below 1
first, or the equations their enclosure, there is no certificate, and the report has the reason.
"""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import SystemFailedError
from noack.plants.systems.enclosed_motion import EnclosedMotion, Inclusion
from noack.plants.systems.traced_equations import NotEnclosedError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus
from noack.theory.certificates.certified_bounds import Region, ScenarioCertificate
from noack.theory.certificates.conditions import REGION
from noack.theory.certificates.constants_search import Phases
from noack.theory.certificates.plant_equations import LinearEquations, enclosed_motion, linear_plant
from noack.theory.certificates.refusals import refusal_under
from noack.theory.certificates.scenario_certificates import CertificateScope, box_scope, own_plant_scope
from noack.theory.coverage import refusals, without_loads

_WIDER = 1.02
"""The next region is larger than the bounds by this factor."""
_LEAST = 1e-9
"""Least width of a region in each direction, as a share of its largest."""
_ATTEMPTS = 40
"""Regions that are tried."""
_LEAST_SHARE, _BISECTIONS = 1e-3, 5
"""Where a region has no bounds: the least share of it that is tried, and the steps to the largest one."""
_NO_BOUNDS = (NotEnclosedError, SystemFailedError, NoCertificateError, NotDecayingError)
"""Why a region has no bounds."""
_FROM_EQUATIONS = (NotEnclosedError, SystemFailedError)
"""Those of them that come from the equations, also from a user's class."""
_MOST_NAMES = 8
"""Maximum number of bounds of a region that a reason names."""
_TIMES = ("sampling_s", "spacing_s", "delay_s", "hold_s", "start_s")
"""The times of conditions with which the bounds increase."""


def scopes(resolved: Scenario, start_error: float | None = None) -> list[CertificateScope]:
    """Return the plants of a resolved scenario for which certificates can exist.

    These are its own plant and the box around it, if it is linear by its settings; otherwise its
    plant, on a region if its equations are not linear.
    """
    if not refusals(without_loads(resolved), "linear"):
        linear = own_plant_scope(resolved, start_error), box_scope(resolved, start_error)
        return [scope for scope in linear if scope is not None]
    return [] if refusals(resolved) else [nonlinear_scope(resolved)]


def nonlinear_scope(resolved: Scenario, start: Matrix | None = None) -> CertificateScope:
    """Return the scope of a plant that is not linear by its settings: on a region, if it is not linear.

    ``start``: as of :class:`CertificateScope`.
    """
    linear = linear_plant(resolved)
    return RegionScope(resolved, start) if linear is None else LinearEquations(resolved, linear, start)


class _Box(CertificateScope):
    """The plants of an inclusion."""

    def __init__(self, resolved: Scenario, inclusion: Inclusion, start: Matrix | None) -> None:
        A, B, half_A, half_B = inclusion

        def plant_at(error: ErrorGains, start: Matrix, alpha_per_s: float) -> PlantGains:
            return BoxGains(error, A, B, start, alpha_per_s, half_A, half_B)

        closed_loop = A + B @ loop_of(resolved).K
        super().__init__(REGION, resolved, closed_loop, plant_at, start=start)

    def bounded(self, conditions: NetworkConditions) -> tuple[list[Phases], Vector]:
        """Return constants, and for bounds of |x_j| and |u_i| at all times, (n + m,).

        Without decay the bounds at all times are often smaller, and exist for larger boxes.

        Raises:
            NoCertificateError, NotDecayingError: there are none.
        """
        try:
            phases = self._constants.without_decay(conditions)
        except (NoCertificateError, NotDecayingError, OverflowError, np.linalg.LinAlgError):
            phases = self.all_phases(conditions)
        return phases, self._coordinate_bounds(phases, conditions)

    def _coordinate_bounds(self, phases: list[Phases], conditions: NetworkConditions) -> Vector:
        bounds = list[Vector]()
        for phase in phases:
            total = np.zeros(self._loop.n + self._loop.m)
            for plant, constants in self._constants.with_plants(phase):
                assert isinstance(plant, BoxGains)
                total += plant.coordinate_bounds(constants.input_error, conditions.start_s)
            bounds.append(total)
        return np.asarray(np.min(bounds, axis=0))


class _ProvenRegion(NamedTuple):
    """A region that x and u do not leave, and the decay rates of the box over it."""

    region: Region
    decay_per_s: Mapping[str, float]


class RegionScope(_Box):
    """A nonlinear plant within a region; see :class:`CertificateScope`."""

    def __init__(self, resolved: Scenario, start: Matrix | None = None) -> None:
        loop, self._proven = loop_of(resolved), dict[NetworkConditions, _ProvenRegion]()
        self._other_start = start
        # The plants of the model; those of each region take their place.
        model = Inclusion(loop.A_model, loop.B_model, 0 * loop.A_model, 0 * loop.B_model)
        super().__init__(resolved, model, start)

    @np.errstate(all="ignore")
    def certificate(
        self, conditions: NetworkConditions, *, knows_delay: bool = False, knows_inputs: bool = False
    ) -> ScenarioCertificate:
        """Return the certificate under some conditions, and its region."""
        certificate = super().certificate(conditions, knows_delay=knows_delay, knows_inputs=knows_inputs)
        if certificate.constants is None:
            return certificate
        region = self._proven[conditions].region
        why = "the bounds on the region are inside it, so that there is no first exit"
        stays = "x and u stay in the region over which the equations are enclosed"
        proven = Assumption(stays, "certificate", AssumptionStatus.HOLDS, why)
        assumptions = (*certificate.assumptions, proven, self._rest())
        return replace(certificate, region=region, assumptions=assumptions)

    def _decay_under(self, conditions: NetworkConditions) -> Mapping[str, float]:
        proven = self._proven.get(conditions)
        return self.decay_per_s if proven is None else proven.decay_per_s

    def _rest(self) -> Assumption:
        """Return that f(0, 0) = 0, on which the inclusion rests."""
        assumed, left = "the plant rests at x = 0, u = 0", float(self._motion.at_rest.max())
        if left == 0:
            return Assumption(assumed, "certificate", AssumptionStatus.HOLDS, "ẋ is 0 there")
        why = f"an entry of ẋ is at most {left:.2g} there; the bounds leave it out"
        return Assumption(assumed, "certificate", AssumptionStatus.ASSUMED, why)

    @np.errstate(all="ignore")
    def loop_gain(self, conditions: NetworkConditions) -> float:
        """Return the loop gain on the region; at least 1, perhaps infinite, if there is none."""
        if refusal_under(conditions, self._resolved, self.name, knows_delay=True) is not None:
            return math.inf
        try:
            phases = self.all_phases(conditions, longest=False, near=True)
        except NoCertificateError as error:
            return max(error.loop_gain, 1.0)
        except NotDecayingError:
            return math.inf
        return max(phase.loop_gain for phase in phases[0] if phase is not None)

    def all_phases(
        self, conditions: NetworkConditions, *, longest: bool = True, near: bool = False
    ) -> list[Phases]:
        """Return the constants on a region that x and u do not leave.

        ``longest``: search for the tightest bounds on this region; otherwise any suffice. ``near``:
        begin with the region of shorter times; the search may end before it has found a region.

        Raises: as :meth:`CertificateScope.all_phases`.
        """
        widths = self._widths_within(conditions) if near else np.zeros(self._loop.n + self._loop.m)
        step = 0.0
        for _ in range(_ATTEMPTS):
            try:
                inclusion, plants, phases, reached = self._bounded(widths, conditions)
            except _NO_BOUNDS as error:
                why = str(error) if near else self._reason(error, widths, conditions)
                if isinstance(error, NotDecayingError):
                    raise NotDecayingError(why) from None
                gain = error.loop_gain if isinstance(error, NoCertificateError) else math.inf
                raise NoCertificateError(why, gain) from None
            if (reached < widths).all():
                region = Region.of(widths, inclusion)
                self._proven[conditions] = _ProvenRegion(region, plants.decay_per_s)
                if longest:
                    with contextlib.suppress(NoCertificateError, NotDecayingError):
                        return plants.all_phases(conditions)
                return phases
            wider = np.maximum(widths, _WIDER * reached + _LEAST * reached.max())
            # The bounds grow faster than the region: towards a region that holds them, steps shrink.
            grown, step = step, float(np.linalg.norm(wider - widths))
            if near and 0 < grown < step:
                break
            widths = wider
        raise NoCertificateError(
            f"on the region {self._described(widths)}: the bounds are not within it, as on the smaller ones"
        )

    def _bounded(
        self, widths: Vector, conditions: NetworkConditions
    ) -> tuple[Inclusion, _Box, list[Phases], Vector]:
        """Return the box over a region, as matrices and as plants, and :meth:`_Box.bounded` of it.

        Raises: one of ``_NO_BOUNDS``.
        """
        inclusion = self._motion.over(widths)
        plants = _Box(self._resolved, inclusion, self._other_start)
        return inclusion, plants, *plants.bounded(conditions)

    def _reason(self, error: Exception, widths: Vector, conditions: NetworkConditions) -> str:
        """Return why there is no certificate: the error on a region, and where there is none."""
        if not widths.any():
            return str(error) if isinstance(error, _FROM_EQUATIONS) else f"near 0: {error}"
        share = self._largest_share(error, widths, conditions)
        needed = f"the bounds from x(0) need the region {self._described(widths)}, and there "
        needed += f"{error}{self._steepest(widths)}"
        if share == 0:
            return f"{needed}; so it is on one of {_LEAST_SHARE:g} of this size"
        largest = share * widths
        start = np.abs(self._start).max(axis=1)
        outside = int((start / largest[: self._loop.n]).argmax())
        why = f"{needed}; it is not so on {self._described(largest)}"
        if start[outside] <= largest[outside]:
            return why
        limit = f"{largest[outside]:.3g}, and it starts at {start[outside]:.3g}"
        return f"{why}, which does not contain the start: |{self._loop.state_names[outside]}| ≤ {limit}"

    def _largest_share(self, error: Exception, widths: Vector, conditions: NetworkConditions) -> float:
        """Return a share of a region without such an error, nearly the largest one; 0 if none is found."""

        def has_bounds(share: float) -> bool:
            try:
                if isinstance(error, _FROM_EQUATIONS):
                    self._motion.over(share * widths)
                else:
                    self._bounded(share * widths, conditions)
            except _NO_BOUNDS:
                return False
            return True

        if not has_bounds(_LEAST_SHARE):
            return 0.0
        low, high = _LEAST_SHARE, 1.0
        for _ in range(_BISECTIONS):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if has_bounds(middle) else (low, middle)
        return low

    def _steepest(self, widths: Vector) -> str:
        """Return, as text, the slope of the equations over a region that varies most; empty if none does."""
        try:
            A, B, half_A, half_B = self._motion.over(widths)
        except _FROM_EQUATIONS:
            return ""
        centre, half = np.hstack([A, B]), np.hstack([half_A, half_B])
        sizes = ((np.abs(centre) + half) * widths).sum(axis=1, keepdims=True)
        shares = half * widths / np.where(sizes > 0, sizes, 1.0)
        i, j = np.unravel_index(int(shares.argmax()), shares.shape)
        if not shares[i, j]:
            return ""
        states, inputs = self._loop.state_names, self._loop.input_names
        low, high = centre[i, j] - half[i, j], centre[i, j] + half[i, j]
        name = (*states, *inputs)[j]
        return f" (the slope of d{states[i]}/dt by {name} is from {low:.3g} to {high:.3g} there)"

    def _widths_within(self, conditions: NetworkConditions) -> Vector:
        """Return the newest region of shorter times, where a search ends sooner than from 0.

        The bounds increase with the times, so that this region is not larger than the smallest one.
        """
        for known, (region, _) in reversed(self._proven.items()):
            shorter = all(getattr(known, name) <= getattr(conditions, name) for name in _TIMES)
            if shorter and known.guarantee == conditions.guarantee:
                return np.array(region.x + region.u)
        return np.zeros(self._loop.n + self._loop.m)

    def _described(self, widths: Vector) -> str:
        if len(widths) > _MOST_NAMES:
            return f"|x_j| ≤ {widths[: self._loop.n].max():.3g}"
        names = (*self._loop.state_names, *self._loop.input_names)
        return ", ".join(f"|{name}| ≤ {w:.3g}" for name, w in zip(names, widths, strict=True))

    @cached_property
    def _motion(self) -> EnclosedMotion:
        return enclosed_motion(self._resolved)
