"""Methods whose results are kept in their object."""

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

Owner = TypeVar("Owner")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def cached_method(
    method: Callable[Concatenate[Owner, Arguments], Result],
) -> Callable[Concatenate[Owner, Arguments], Result]:
    """Compute a method once for each combination of arguments, which are hashable or arrays.

    The object must not change. Unlike :func:`functools.cache` this needs no hash of the object, and
    the results end with it.
    """
    results = f"results of {method.__qualname__}"

    @wraps(method)
    def found(self: Owner, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        known: dict[object, Result] = self.__dict__.setdefault(results, {})
        key = (*map(_key, args), *kwargs.items())
        if key not in known:
            known[key] = method(self, *args, **kwargs)
        return known[key]

    return found


def _key(argument: object) -> object:
    """Return the bits of an array, or another argument as it is."""
    if isinstance(argument, np.ndarray):
        return argument.shape, argument.tobytes()
    return argument
