"""Scenario files: TOML in, frozen scenario out, and one clear line for every mistake."""

import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError

from noack.errors import CallerError
from noack.mistakes import explain
from noack.scenario import Scenario


def load(path: Path, overrides: Iterable[str] = ()) -> Scenario:
    """Read and validate a scenario file.

    Args:
        path: the TOML file.
        overrides: ``key=value`` settings that replace the file's, e.g. ``trigger.beta=0.3``.

    Raises:
        CallerError: one line per mistake, each with file, key, value and remedy.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise CallerError(_missing(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise CallerError(f"{path}: cannot be read as text: {error}") from None
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise CallerError(f"{path}: not valid TOML: {error}") from None
    for override in overrides:
        _apply(content, override)
    return validate(content, str(path))


def validate(content: Mapping[str, Any], source: str) -> Scenario:
    """Validate parsed content; ``source`` names it in error messages.

    Raises:
        CallerError: one line per mistake.
    """
    try:
        # Through JSON, because strict validation takes arrays for tuples only there.
        return Scenario.model_validate_json(json.dumps(content, default=_unfit))
    except TypeError as error:
        raise CallerError(f"{source}: {error}") from None
    except ValidationError as error:
        raise CallerError("\n".join(explain(error, source))) from None


def dumps(scenario: Scenario) -> str:
    """Return the scenario as TOML that :func:`load` reads back to an equal scenario."""
    return tomli_w.dumps(scenario.model_dump(mode="json", exclude_none=True), indent=2)


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files, for editors."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    } | Scenario.model_json_schema()


def _apply(content: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise CallerError(f"--set {override}: write it as key=value, e.g. trigger.beta=0.3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is taken as a string
    except (ValueError, RecursionError) as error:
        raise CallerError(f"--set {key}: not valid TOML: {error}") from None
    table = content
    *path, last = key.strip().split(".")
    for part in path:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise CallerError(f"--set {override}: {part} is not a table")
    table[last] = value


def _missing(path: Path) -> str:
    others = sorted(path.parent.glob("*.toml")) if path.parent.is_dir() else []
    names = ", ".join(str(other) for other in others[:10])
    return f"{path}: no such file" + (f"; there are {names}" if names else "")


def _unfit(value: object) -> None:
    raise TypeError(f"{value}: a date or time is no value of a scenario; write text in quotes")
