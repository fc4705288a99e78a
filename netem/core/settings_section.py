"""Parts of every table of a settings file: base class, numbers, kinds.

A kind of settings is one module: a module in the kind's folder, or of an extension, adds it
(:func:`kinds_in`).
"""

import ast
import inspect
import sys
from collections.abc import Mapping
from functools import cache, reduce
from itertools import pairwise
from operator import or_
from types import ModuleType
from typing import Annotated, ClassVar, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Discriminator, Field, FiniteFloat, GetJsonSchemaHandler, Tag
from pydantic_core import CoreSchema

from netem.core import extension_points

Table = dict[str, object]
"""A table of a settings file before it is validated: the values that JSON or TOML has."""
ReadTable = Mapping[str, object]
"""The same, where it is only read."""
Positive = Annotated[FiniteFloat, Field(gt=0)]
FolderName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
"""The name of a scenario, a loop, a campaign or a link: folders, files and channels are called so."""
NonNegative = Annotated[FiniteFloat, Field(ge=0)]
Probability = Annotated[FiniteFloat, Field(ge=0, le=1)]
Correlation = Annotated[FiniteFloat, Field(ge=0, lt=1)]
LARGEST_SEED = 2**64 - 1
Seed = Annotated[int, Field(ge=0, lt=2**64)]


class ScenarioSection(BaseModel):
    """A frozen table of a settings file that refuses unknown keys."""

    # Validators are built at their first use, that of a scenario with those of all its tables. So
    # defaults in classes are made by model_construct, which needs no validator.
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True)

    key_hints: ClassVar[Mapping[str, str]] = {}
    """What is said of unknown keys anywhere in the file of this root table."""
    extension_groups: ClassVar[Mapping[str, str]] = {}
    """By key: the group of entry points of extensions that have kinds of this table."""

    # The results of cached methods are kept with a section. They are no part of it.

    def __copy__(self) -> Self:
        """Return a copy, whose keys may then change."""
        copied = super().__copy__()
        for name in self.__dict__.keys() - type(self).__pydantic_fields__.keys():
            del copied.__dict__[name]
        return copied

    def __eq__(self, other: object) -> bool:
        """Whether it is the same table."""
        if not isinstance(other, ScenarioSection) or type(self) is not type(other):
            return False
        return self.__copy__().__dict__ == other.__copy__().__dict__

    def __getstate__(self) -> Table:
        """Return what is pickled."""
        return super().__getstate__() | {"__dict__": self.__copy__().__dict__}

    def content(self) -> Table:
        """Return the table as JSON has it, without keys that have no value."""
        return self.model_dump(mode="json", exclude_none=True)

    @classmethod
    def key_descriptions(cls) -> dict[str, str]:
        """Return the docstrings of the keys.

        They are parsed from the source only when a schema or a message needs them: pydantic's
        ``use_attribute_docstrings`` parses all of them at import, which takes 0.2 s.
        """
        descriptions: dict[str, str] = {}
        for section in reversed(cls.__mro__[: cls.__mro__.index(ScenarioSection)]):
            descriptions |= _docstrings(section.__module__).get(section.__name__, {})
        return descriptions

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler, /) -> Table:
        """Return the JSON Schema with the descriptions of the keys."""
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        descriptions = cls.key_descriptions()
        for key in properties.keys() & descriptions.keys():
            properties[key]["description"] = descriptions[key]
        return schema


@cache
def _docstrings(module: str) -> dict[str, dict[str, str]]:
    """Return the docstrings of the attributes of a module's classes, by class."""
    docstrings: dict[str, dict[str, str]] = {}
    try:
        statements = ast.parse(inspect.getsource(sys.modules[module])).body
    except OSError:  # installed without sources
        return docstrings
    for section in [statement for statement in statements if isinstance(statement, ast.ClassDef)]:
        for pair in pairwise(section.body):
            match pair:
                case (ast.AnnAssign(target=ast.Name(id=key)), ast.Expr(value=ast.Constant(value=str(text)))):
                    docstrings.setdefault(section.name, {})[key] = inspect.cleandoc(text)
    return docstrings


Settings = TypeVar("Settings", bound=ScenarioSection)


def kinds_in(
    package: str, base: type[Settings], key: str = "kind", group: str = ""
) -> Mapping[str, type[Settings]]:
    """Return the settings classes that modules define, by their kind.

    They are subclasses of ``base``. The field ``key``, a ``Literal`` of one value, names the kind.
    The modules are those of a package of noack and, with ``group``, those of installed extensions
    (:func:`netem.core.extension_points.parts`).
    """
    kinds: dict[str, type[Settings]] = {}

    def read(module: ModuleType) -> dict[str, type[Settings]] | None:
        found: dict[str, type[Settings]] = {}
        for member in vars(module).values():
            if isinstance(member, type) and issubclass(member, base) and member.__module__ == module.__name__:
                names = get_args(member.model_fields[key].annotation)  # empty for a base class
                found |= dict.fromkeys(names, member)
        if not module.__name__.startswith(f"{package}."):
            for settings in found.values():
                settings.model_rebuild()  # an annotation that is wrong concerns this extension alone
        if taken := found.keys() & kinds.keys():
            raise ValueError(f"{key} = {', '.join(sorted(taken))} exists already")
        return found or None

    for part in extension_points.parts(package, group, read):
        kinds |= part
    return kinds


def union_of(
    kinds: Mapping[str, type[ScenarioSection]], key: str = "kind", default: str | None = None
) -> object:
    """Return the type of a table that is one of these kinds, for pydantic.

    The field ``key`` names the kind; it may be omitted in a table of the kind ``default``.
    """
    if default is None:
        return Annotated[reduce(or_, kinds.values()), Discriminator(key)]

    def kind(table: object) -> str:
        value = table.get(key, default) if isinstance(table, dict) else getattr(table, key, default)
        return str(value)

    tagged = [Annotated[settings, Tag(name)] for name, settings in kinds.items()]
    return Annotated[reduce(or_, tagged), Discriminator(kind)]
