"""Elementary functions of floats, and of numbers that carry an enclosure.

Equations that use these functions, or numpy's, are the plant's motion and a certificate's evidence
alike: evaluated with floats they give dx/dt, evaluated with the numbers of
:mod:`noack.plants.systems.jacobian_enclosure` they give enclosed derivatives. numpy's functions
call a method of the same name of such a number, and so do these.
"""

import math
from collections.abc import Callable


def _of_number(name: str, of_float: Callable[[float], float]) -> Callable[[object], float]:
    def function(x: object) -> float:
        if isinstance(x, float):
            return of_float(x)
        value: float = getattr(x, name)()  # stands for a float in the equations
        return value

    return function


sin = _of_number("sin", math.sin)
cos = _of_number("cos", math.cos)
sqrt = _of_number("sqrt", math.sqrt)
