"""Methods whose results are kept; their arguments may be arrays."""

from collections.abc import Callable, Hashable
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
    def wrapper(self: Owner, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        by_key: dict[Hashable, Result] = self.__dict__.setdefault(results, {})
        key = _bits(*args, **kwargs)
        if key not in by_key:
            by_key[key] = method(self, *args, **kwargs)
        return by_key[key]

    return wrapper


def _bits(*args: object, **kwargs: object) -> Hashable:
    return *map(_key, args), *((name, _key(value)) for name, value in kwargs.items())


def _key(argument: object) -> object:
    """Return the bits of an array, or another argument as it is."""
    if isinstance(argument, np.ndarray):
        return argument.shape, argument.tobytes()
    return argument
