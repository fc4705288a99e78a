"""A plant's equations for certificates: to be enclosed on a region, or proven to be linear everywhere.

Where the derivatives of the equations are the same for all x and u, the plant is ẋ = A x + B u. It
has the certificates of a linear plant from any x(0), and needs no region.
"""

from dataclasses import replace

import numpy as np

from noack.core.errors import NoackError
from noack.core.linear_systems import Matrix
from noack.plants.linear import LinearSettings
from noack.plants.plant_settings import PlantStart, PlantSystem
from noack.plants.systems.enclosed_motion import EnclosedMotion
from noack.plants.systems.traced_equations import NotEnclosedError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.assumptions import Assumption, AssumptionStatus
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import LINEAR_EQUATIONS
from noack.theory.certificates.scenario_certificates import CertificateScope


def enclosed_motion(resolved: Scenario) -> EnclosedMotion:
    """Return the equations of a resolved scenario's plant, to be enclosed.

    Raises:
        NotEnclosedError: it has no equations that can be enclosed, or does not accept x = 0.
    """
    loop = loop_of(resolved)
    return EnclosedMotion(equations_of(resolved), loop.n, loop.m)


def equations_of(resolved: Scenario) -> PlantSystem:
    """Return a resolved scenario's plant at x = 0, with its equations.

    Raises:
        NotEnclosedError: it has no equations that can be enclosed, or does not accept x = 0.
    """
    loop, plant, model = loop_of(resolved), resolved.plant.system, resolved.model
    if not plant.has_equations:
        raise NotEnclosedError(f'a plant of kind "{plant.kind}" has no equations to enclose')
    if model.states != model.plant_states:
        whose = "a load" if model.load_states else "the controller"
        raise NotEnclosedError(f"its equations have no enclosure with a state of {whose}")
    start = PlantStart(np.zeros(loop.n), loop.A_model, loop.B_model, resolved.timing.plant_period_ns)
    try:
        return plant.system(start)
    except NoackError as error:  # a user's class that does not accept x = 0, for example
        raise NotEnclosedError(str(error)) from None


def linear_plant(resolved: Scenario) -> Scenario | None:
    """Return the scenario with the linear plant that its plant's equations are; None if they are not linear.

    Without its uncertainty box, which is around the model. None also at a set-point, where only a
    plant that is linear by its settings has certificates.
    """
    plant = resolved.plant
    if resolved.coverage.is_linear or resolved.controller.setpoint is not None:
        return None
    try:
        matrices = enclosed_motion(resolved).linear()
    except NoackError:  # the user's class may refuse large values
        return None
    if matrices is None:
        return None
    A, B = (tuple(map(tuple, matrix.tolist())) for matrix in matrices)
    update = {"system": LinearSettings(), "draw": "given", "A": A, "B": B}
    update |= {"uncertainty_A": None, "uncertainty_B": None}
    return resolved.model_copy(update={"plant": plant.model_copy(update=update)})


def linearity(resolved: Scenario) -> Assumption:
    """Return on what the certificates of a plant with linear equations rest: on A and B, to rounding."""
    kind = resolved.plant.system.kind
    why = f'the derivatives of its equations (kind "{kind}") are the same for all x and u, to rounding'
    return Assumption("the plant is ẋ = Ax + Bu", "certificate", AssumptionStatus.HOLDS, why)


class LinearEquations(CertificateScope):
    """A plant with linear equations; see :class:`CertificateScope`.

    Args:
        resolved: the scenario.
        linear: the same with the linear plant.
        start: as of :class:`CertificateScope`.
    """

    def __init__(self, resolved: Scenario, linear: Scenario, start: Matrix | None = None) -> None:
        loop, self._linearity = loop_of(linear), linearity(resolved)

        def plant_at(error: ErrorGains, start: Matrix, alpha_per_s: float) -> PlantGains:
            return PlantGains(error, loop.A, loop.B, start, alpha_per_s)

        closed_loop = loop.A + loop.B @ loop.K
        super().__init__(LINEAR_EQUATIONS, linear, closed_loop, plant_at, start=start)

    def certificate(
        self, conditions: NetworkConditions, *, knows_delay: bool = False, knows_inputs: bool = False
    ) -> ScenarioCertificate:
        """Return the certificate under some conditions; it rests on the equations' being linear."""
        certificate = super().certificate(conditions, knows_delay=knows_delay, knows_inputs=knows_inputs)
        return replace(certificate, assumptions=(*certificate.assumptions, self._linearity))
