"""Settings files: TOML in, a frozen model out, and one clear line for every mistake."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from noack.errors import CallerError, printable
from noack.mistakes import explain

M = TypeVar("M", bound=BaseModel)


def read(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        CallerError: there is no such file, or it is no TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CallerError(_missing(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise CallerError(f"{path}: cannot be read as text: {error}") from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise CallerError(printable(f"{path}: not valid TOML: {error}")) from None


def validated(model: type[M], content: Mapping[str, Any], source: str) -> M:
    """Validate parsed content; ``source`` names it in error messages.

    Raises:
        CallerError: one line per mistake, each with file, key, value and remedy.
    """
    try:
        # Through JSON, because strict validation takes arrays for tuples only there.
        return model.model_validate_json(json.dumps(content, default=_unfit))
    except TypeError as error:
        raise CallerError(printable(f"{source}: {error}")) from None
    except ValidationError as error:
        raise CallerError("\n".join(explain(error, source, model))) from None


def json_schema(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON Schema of a file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | model.model_json_schema()


def _missing(path: Path) -> str:
    others = sorted(path.parent.glob("*.toml")) if path.parent.is_dir() else []
    names = ", ".join(str(other) for other in others[:10])
    return f"{path}: no such file" + (f"; there are {names}" if names else "")


def _unfit(value: object) -> None:
    raise TypeError(f"{value}: a date or time is no value of a setting; write text in quotes")
