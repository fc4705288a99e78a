"""Scenario files: TOML in, frozen scenario out, and one clear line for every mistake."""

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import tomli_w
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from noack.errors import CallerError
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
    except tomllib.TOMLDecodeError as error:
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
        return Scenario.model_validate_json(json.dumps(content, default=str))
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


def explain(error: ValidationError, source: str) -> list[str]:
    """Turn a validation error into lines ``source: key = value: what is wrong; what is right``."""
    return [_line(details, source) for details in error.errors()]


def _line(details: ErrorDetails, source: str) -> str:
    # Union branches show up in the location ("network.loss.bernoulli.p"); they are no keys.
    location = [part for part in details["loc"] if part not in _LOSS_BRANCHES]
    key = ".".join(str(part) for part in location)
    value = details["input"]
    kind, message, context = details["type"], details["msg"], details.get("ctx", {})
    if kind == "missing":
        return f"{source}: {key}: missing; {_known_keys(location[:-1])}"
    if kind == "extra_forbidden":
        return f"{source}: {key} = {_show(value)}: unknown key; {_nearest(location)}"
    if kind == "value_error":  # raised by a section's own check, which starts with "key: "
        message = str(context["error"])
        inner, colon, rest = message.partition(": ")
        path = f"{key}.{inner}" if key else inner
        shown = _lookup(value, inner)
        return f"{source}: {path}{shown}: {rest}" if colon else f"{source}: {key}: {message}"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        expected = context.get("expected_tags", ", ".join(repr(tag) for tag in _LOSS_BRANCHES))
        return f"{source}: {key}.model: must be one of {expected}; found {_show(value)}"
    remedy = message[0].lower() + message[1:].replace("Input should", "should")
    return f"{source}: {key} = {_show(value)}: {remedy.removeprefix('input ')}"


_LOSS_BRANCHES = ("lossless", "bernoulli", "gilbert_elliott", "worst_case")


def _show(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _lookup(value: Any, path: str) -> str:
    for part in path.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return ""
        value = value[part]
    return f" = {_show(value)}"


def _section(location: Iterable[Any]) -> set[str]:
    """Known keys of the section at ``location``."""
    sections: list[type[BaseModel]] = [Scenario]
    for part in location:
        found: list[type[BaseModel]] = []
        for section in sections:
            if part in section.model_fields:
                found += _sections_in(section.model_fields[part].annotation)
        sections = found
    return {key for section in sections for key in section.model_fields}


def _sections_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) is Union or get_args(annotation):
        return [found for part in get_args(annotation) for found in _sections_in(part)]
    return []


def _known_keys(location: Iterable[Any]) -> str:
    known = _section(location)
    return f"the keys here are {', '.join(sorted(known))}" if known else "it is required"


def _nearest(location: list[Any]) -> str:
    close = difflib.get_close_matches(str(location[-1]), _section(location[:-1]), n=1)
    return f"did you mean {close[0]}?" if close else _known_keys(location[:-1])


def _apply(content: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise CallerError(f"--set {override}: write it as key=value, e.g. trigger.beta=0.3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is taken as a string
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
