"""Kinds of settings, one module each: a module in the folder adds its kind."""

from collections.abc import Mapping
from functools import reduce
from importlib import import_module
from operator import or_
from pkgutil import iter_modules
from typing import Annotated, Any, TypeVar, get_args

from pydantic import Discriminator, Tag

from noack.settings.section import ScenarioSection

Settings = TypeVar("Settings", bound=ScenarioSection)


def kinds_in(package: str, base: type[Settings], key: str = "kind") -> Mapping[str, type[Settings]]:
    """Return the settings classes that the modules of a package define, by their kind.

    They are subclasses of ``base``. The field ``key``, a ``Literal`` of one value, names the kind.
    Subpackages are not searched.
    """
    found: dict[str, type[Settings]] = {}
    for entry in iter_modules(import_module(package).__path__, f"{package}."):
        if entry.ispkg:
            continue
        for one in vars(import_module(entry.name)).values():
            if isinstance(one, type) and issubclass(one, base) and one.__module__ == entry.name:
                names = get_args(one.model_fields[key].annotation)  # empty for a base class
                found |= dict.fromkeys(names, one)
    return found


def union_of(
    kinds: Mapping[str, type[ScenarioSection]], key: str = "kind", default: str | None = None
) -> Any:
    """Return the type of a table that is one of these kinds, for pydantic.

    The field ``key`` names the kind; it may be omitted in a table of the kind ``default``.
    """
    if default is None:
        return Annotated[reduce(or_, kinds.values()), Discriminator(key)]

    def kind(given: object) -> str:
        value = given.get(key, default) if isinstance(given, dict) else getattr(given, key, default)
        return str(value)

    tagged = [Annotated[settings, Tag(name)] for name, settings in kinds.items()]
    return Annotated[reduce(or_, tagged), Discriminator(kind)]
