"""Methods whose results are kept in their object."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np

Method = TypeVar("Method", bound=Callable[..., Any])


def cached_method(method: Method) -> Method:
    """Compute a method once for each combination of arguments, which are hashable or arrays.

    The object must not change. Unlike :func:`functools.cache` this needs no hash of the object, and
    the results end with it.
    """
    results = f"results of {method.__qualname__}"

    @wraps(method)
    def found(self: Any, *args: Any, **kwargs: Any) -> Any:
        known = self.__dict__.setdefault(results, {})
        key = (*map(_key, args), tuple(kwargs.items()))
        if key not in known:
            known[key] = method(self, *args, **kwargs)
        return known[key]

    return cast("Method", found)


def _key(argument: Any) -> Any:
    """Return the bits of an array, or another argument as it is."""
    if isinstance(argument, np.ndarray):
        return argument.shape, argument.tobytes()
    return argument
