"""A plant's equations, of which the checker encloses the derivatives."""

import numpy as np

from netem.core.errors import NoackError
from noack.plants.plant_settings import PlantStart, PlantSystem
from noack.plants.systems.traced_equations import NotEnclosedError
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario


def equations_of(resolved: Scenario) -> PlantSystem:
    """Return a resolved scenario's plant at x = 0, with its equations.

    Raises:
        NotEnclosedError: it has no equations that can be enclosed, or does not accept x = 0.
    """
    loop, plant, model = loop_of(resolved), resolved.plant.system, resolved.model
    if not plant.has_equations:
        raise NotEnclosedError(
            f'plant.system.kind = "{plant.kind}": a plant of this kind has no equations to enclose'
        )
    if model.states != model.plant_states:
        whose = "a load" if model.load_states else "the controller"
        raise NotEnclosedError(f"its equations have no enclosure with a state of {whose}")
    start = PlantStart(np.zeros(loop.n), loop.A_model, loop.B_model, resolved.timing.plant_period_ns)
    try:
        return plant.system(start)
    except NoackError as error:  # a user's class that does not accept x = 0, for example
        raise NotEnclosedError(str(error)) from None
