"""The base of every table in a settings file, and the types of its numbers."""

import ast
import inspect
import sys
from functools import cache
from itertools import pairwise
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, GetJsonSchemaHandler
from pydantic_core import CoreSchema

from noack.core.clock import NS_PER_S

Positive = Annotated[FiniteFloat, Field(gt=0)]
NonNegative = Annotated[FiniteFloat, Field(ge=0)]
Probability = Annotated[FiniteFloat, Field(ge=0, le=1)]
Correlation = Annotated[FiniteFloat, Field(ge=0, lt=1)]
Seed = Annotated[int, Field(ge=0, lt=2**64)]
RateHz = Annotated[FiniteFloat, Field(gt=0, le=100_000)]
_LEAST_RATE_HZ = 1e-9  # lowest rate; its period in nanoseconds fits into 64 bits


class ScenarioSection(BaseModel):
    """A frozen table of a settings file that refuses unknown keys."""

    # Validators are built at their first use, that of a scenario with those of all its tables. So
    # defaults in classes are made by model_construct, which needs no validator.
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True)

    @classmethod
    def key_descriptions(cls) -> dict[str, str]:
        """Return the docstrings of the keys.

        They are parsed from the source only when a schema or a message needs them: pydantic's
        ``use_attribute_docstrings`` parses all of them at import, which takes 0.2 s.
        """
        found: dict[str, str] = {}
        for section in reversed(cls.__mro__[: cls.__mro__.index(ScenarioSection)]):
            found |= _docstrings(section.__module__).get(section.__name__, {})
        return found

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler, /
    ) -> dict[str, Any]:
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
    found: dict[str, dict[str, str]] = {}
    try:
        statements = ast.parse(inspect.getsource(sys.modules[module])).body
    except OSError:  # installed without sources
        return found
    for section in [one for one in statements if isinstance(one, ast.ClassDef)]:
        for pair in pairwise(section.body):
            match pair:
                case (
                    ast.AnnAssign(target=ast.Name(id=key)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    found.setdefault(section.name, {})[key] = inspect.cleandoc(text)
    return found


def period_ns(rate_hz: float) -> int:
    """Return the period of a validated rate, a whole number of nanoseconds."""
    return round(NS_PER_S / rate_hz)


def require_whole_period(rate_hz: float, key: str) -> None:
    """Raise ValueError unless the rate's period is a whole number of nanoseconds."""
    if rate_hz < _LEAST_RATE_HZ:
        raise ValueError(f"{key}: must be at least {_LEAST_RATE_HZ:g}")
    whole_ns = period_ns(rate_hz)
    if whole_ns < 1 or abs(NS_PER_S / whole_ns - rate_hz) > 1e-12 * rate_hz:
        raise ValueError(
            f"{key}: the period must be a whole number of nanoseconds; "
            f"the nearest such rate is {NS_PER_S / max(whole_ns, 1)!r}"
        )
