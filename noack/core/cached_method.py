"""Methods whose results are kept in their object."""

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

Self = TypeVar("Self")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def cached_method(
    method: Callable[Concatenate[Self, Arguments], Result],
) -> Callable[Concatenate[Self, Arguments], Result]:
    """Compute a method once for each combination of arguments; they must be hashable.

    The object must not change. Unlike :func:`functools.cache` this needs no hash of the object, and
    the results end with it.
    """
    results = f"results of {method.__qualname__}"

    @wraps(method)
    def found(self: Self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        known = self.__dict__.setdefault(results, {})
        key = (args, tuple(kwargs.items()))
        if key not in known:
            known[key] = method(self, *args, **kwargs)
        return known[key]  # type: ignore[no-any-return]

    return found
