"""Published results: one per file, whose name is that of ``noack paper NAME``.

The file has a :class:`cosim.studies.paper.published_result.PublishedResult` named ``RESULT``.
"""

import pkgutil
from importlib import import_module
from typing import TYPE_CHECKING

from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError, did_you_mean

with lazy_modules():
    from cosim.studies.paper import published_result

if TYPE_CHECKING:
    from cosim.studies.paper.published_result import PublishedResult, Reproduction

NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


def find_result(name: str) -> "PublishedResult":
    """Return a result; raise CallerError if there is none of this name."""
    if name not in NAMES:
        hint = did_you_mean(name, NAMES) or f"there are {', '.join(NAMES)}"
        raise CallerError(f"{name}: no published result of this name; {hint}")
    result: PublishedResult = import_module(f"{__name__}.{name}").RESULT
    return result


def reproduce(name: str) -> "Reproduction":
    """Compute a result; raise CallerError if there is none of this name."""
    result = find_result(name)
    return published_result.Reproduction(name, result, result.rows())
