"""Parts of every table of a settings file: base class, numbers, vectors, matrices, kinds.

A kind of settings is one module: a module in the kind's folder, or of an extension, adds it
(:func:`kinds_in`).
"""

import ast
import inspect
import json
import math
import sys
from collections.abc import Iterable, Mapping
from fractions import Fraction
from functools import cache, reduce
from itertools import pairwise
from operator import or_
from types import ModuleType
from typing import Annotated, Self, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    FiniteFloat,
    GetJsonSchemaHandler,
    Tag,
)
from pydantic_core import CoreSchema

from noack.core import extension_points
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix
from noack.core.periods import RATE_ROUNDING, period_of
from noack.protocol.wire_format import MAX_DIMENSION

Table = dict[str, object]
"""A table of a settings file before it is validated: the values that JSON or TOML has."""
ReadTable = Mapping[str, object]
"""The same, where it is only read."""
Positive = Annotated[FiniteFloat, Field(gt=0)]

_LONGEST_NAME = 64


def require_name(text: str) -> str:
    """Return the name of an output, a state or an input, or its unit.

    Raise ValueError unless it can stand in a line of text and in the legend of a figure, which reads
    text between two $ as a formula.
    """
    if len(text) > _LONGEST_NAME or not text.isprintable() or text.strip() != text or "$" in text:
        raise ValueError(
            f"names have at most {_LONGEST_NAME} printable characters, no $, and no space at an end"
        )
    return text


Name = Annotated[str, Field(min_length=1, max_length=_LONGEST_NAME), AfterValidator(require_name)]
"""How outputs, states and inputs are called in texts and figures."""
FolderName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
"""The name of a scenario, a loop, a campaign or a link: folders, files and channels are called so."""
Unit = Annotated[str, Field(max_length=24), AfterValidator(require_name)]
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


def _with_period(rate_hz: float) -> float:
    """Raise ValueError if steps at this rate would drift from their times."""
    if abs(1 - (exact := period_of(rate_hz).exact * Fraction(rate_hz) / NS_PER_S)) > RATE_ROUNDING:
        raise ValueError(
            "the period is too near to a whole number of nanoseconds; "
            f"the nearest such rate is {float(rate_hz / exact)!r}"
        )
    return rate_hz


RateHz = Annotated[FiniteFloat, Field(ge=1e-6, le=100_000), AfterValidator(_with_period)]
"""A run has at most 1e7 s: the times of its steps fit into 64 bits."""
Row = Annotated[tuple[FiniteFloat, ...], Field(min_length=1, max_length=MAX_DIMENSION)]
"""A vector."""
MatrixRows = Annotated[tuple[Row, ...], Field(min_length=1, max_length=MAX_DIMENSION)]
"""A matrix by rows."""

_LONGEST_SHOWN = 60
"""Longest transposed matrix that a message shows, in characters."""


def _not_negative(title: str, most: float = math.inf) -> AfterValidator:
    """Require entries from 0 to ``most``; the squares of larger ones might overflow."""

    def check(row: tuple[float, ...]) -> tuple[float, ...]:
        if any(entry < 0 for entry in row):
            raise ValueError(f"{title} cannot be negative")
        if any(entry > most for entry in row):
            raise ValueError(f"{title} can be {most:g} at most")
        return row

    return AfterValidator(check)


Deviations = Annotated[Row, _not_negative("standard deviations", 1e100)]
"""Standard deviations, entry by entry."""
Bounds = Annotated[Row, _not_negative("bounds", 1e100)]
"""Largest absolute values, entry by entry."""
HalfWidths = Annotated[Row, _not_negative("half-widths")]
"""Half-widths of intervals, entry by entry."""
HalfWidthRows = Annotated[tuple[HalfWidths, ...], Field(min_length=1, max_length=MAX_DIMENSION)]


def rows_of(matrix: Matrix) -> tuple[tuple[float, ...], ...]:
    """Return a matrix by rows."""
    return tuple(map(tuple, matrix.tolist()))


def shape(rows: tuple[tuple[float, ...], ...], key: str) -> tuple[int, int]:
    """Return (rows, columns) of a matrix; raise ValueError if its rows differ in length."""
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        raise ValueError(f"{key}: all rows need the same length, found lengths {sorted(widths)}")
    return len(rows), widths.pop()


def require_shape(
    rows: tuple[tuple[float, ...], ...] | None, key: str, expected: tuple[int, int], reason: str
) -> None:
    """Raise ValueError if a matrix is given and does not have the expected shape."""
    if rows is None:
        return
    actual = shape(rows, key)
    if actual != expected:
        raise ValueError(
            f"{key}: expected {expected[0]} x {expected[1]} ({reason}), found {actual[0]} x {actual[1]}"
            + (_transposed(rows) if actual == expected[::-1] else "")
        )


def _transposed(rows: Iterable[Iterable[float]]) -> str:
    transposed = json.dumps([list(column) for column in zip(*rows, strict=True)])
    return "; looks transposed" + (f": try {transposed}" if len(transposed) <= _LONGEST_SHOWN else "")


def require_length(row: tuple[object, ...] | None, key: str, expected: int, reason: str) -> None:
    """Raise ValueError if a vector or list of names is given and has another length."""
    if row is not None and len(row) != expected:
        raise ValueError(f"{key}: expected {expected} entries ({reason}), found {len(row)}")


def require_distinct(names: tuple[str, ...] | None, key: str) -> None:
    """Raise ValueError if a name occurs twice in a list of names that is given."""
    for name in names or ():
        if (names or ()).count(name) > 1:
            given = ", ".join(names or ())
            raise ValueError(f"{key}: {name} occurs more than once in {given}; give each a name of its own")


Settings = TypeVar("Settings", bound=ScenarioSection)


def kinds_in(
    package: str, base: type[Settings], key: str = "kind", group: str = ""
) -> Mapping[str, type[Settings]]:
    """Return the settings classes that modules define, by their kind.

    They are subclasses of ``base``. The field ``key``, a ``Literal`` of one value, names the kind.
    The modules are those of a package of noack and, with ``group``, those of installed extensions
    (:func:`noack.core.extension_points.parts`).
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
