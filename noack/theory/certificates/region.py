"""Certificates of a nonlinear plant on a region that it is proven not to leave.

Over the region |x_j| ≤ r_j, |u_i| ≤ r_{n+i} the plant's equations are enclosed: they are A x + B u
with some A and B of a box, which may change at any time (:mod:`jacobian_enclosure
<noack.plants.systems.jacobian_enclosure>`). As long as x and u are in the region, the bounds of the
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

from noack.core.errors import NoackError
from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantStart, SystemFailedError
from noack.plants.systems.jacobian_enclosure import EnclosedMotion, Inclusion, NotEnclosedError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus
from noack.theory.certificates.certified_bounds import Region, ScenarioCertificate
from noack.theory.certificates.conditions import REGION, void_by_safe_input, void_by_uneven_steps
from noack.theory.certificates.constants_search import Phases
from noack.theory.certificates.scenario_certificates import CertificateScope, box_scope, own_plant_scope

_WIDER = 1.02
"""The next region is larger than the bounds by this factor."""
_LEAST = 1e-9
"""Least width of a region in each direction, as a share of its largest."""
_ATTEMPTS = 40
"""Regions that are tried."""
_MOST_NAMES = 8
"""Maximum number of bounds of a region that a reason names."""
_TIMES = ("sampling_s", "spacing_s", "delay_s", "hold_s", "start_s")
"""The times of conditions with which the bounds increase."""


def scopes(resolved: Scenario, start_error: float | None = None) -> list[CertificateScope]:
    """Return the plants of a resolved scenario for which certificates can exist.

    These are its own plant and the box around it, if it is linear; otherwise its plant on a region.
    """
    if resolved.coverage.linear_certificates_apply:
        linear = own_plant_scope(resolved, start_error), box_scope(resolved, start_error)
        return [scope for scope in linear if scope is not None]
    return [RegionScope(resolved)] if resolved.coverage.some_certificate_applies else []


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
    def certificate_unless(self, why: str | None, conditions: NetworkConditions) -> ScenarioCertificate:
        """Return the certificate under some conditions, and its region."""
        certificate = super().certificate_unless(why, conditions)
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
        if void_by_safe_input(self._resolved, conditions) or void_by_uneven_steps(self._resolved):
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
        where, step = "near 0", 0.0
        for _ in range(_ATTEMPTS):
            try:
                inclusion = self._motion.over(widths)
                plants = _Box(self._resolved, inclusion, self._other_start)
                phases, reached = plants.bounded(conditions)
            except (NotEnclosedError, SystemFailedError) as error:  # also from a user's class
                why = f"{where}: {error}" if widths.any() else str(error)
                raise NoCertificateError(why) from None
            except NoCertificateError as error:
                raise NoCertificateError(f"{where}: {error}", error.loop_gain) from None
            except NotDecayingError as error:
                raise NotDecayingError(f"{where}: {error}") from None
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
            widths, where = wider, f"on the region {self._described(wider)}"
        raise NoCertificateError(f"{where}: the bounds are not within it")

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


def enclosed_motion(resolved: Scenario) -> EnclosedMotion:
    """Return the equations of a resolved scenario's plant, to be enclosed.

    Raises:
        NotEnclosedError: it has no equations that can be enclosed, or does not accept x = 0.
    """
    loop, plant = loop_of(resolved), resolved.plant.system
    if not plant.has_equations:
        raise NotEnclosedError(f'a plant of kind "{plant.kind}" has no equations to enclose')
    start = PlantStart(np.zeros(loop.n), loop.A_model, loop.B_model, resolved.timing.plant_period_ns)
    try:
        system = plant.system(start)
    except NoackError as error:  # a user's class that does not accept x = 0, for example
        raise NotEnclosedError(str(error)) from None
    return EnclosedMotion(system, loop.n, loop.m)
