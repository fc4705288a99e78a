"""Words for mistakes in a scenario: ``file: key = value: what is wrong; what would be right``."""

import difflib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from noack.scenario import Loss, Scenario

_LOSS = ("network", "loss")
_LOSSES: Mapping[str, type[BaseModel]] = {
    get_args(settings.model_fields["model"].annotation)[0]: settings
    for settings in get_args(get_args(Loss)[0])
}

_REMEDIES = {
    "string_pattern_mismatch": "use letters, digits, _ and -, beginning with a letter or digit, "
    "at most 64",
    "too_short": "needs at least one entry",
    "tuple_type": "should be a list; a matrix is a list of rows, e.g. [[0.0, 1.0], [2.0, 3.0]]",
}


def explain(error: ValidationError, source: str) -> list[str]:
    """Return one line per mistake; ``source`` names the file."""
    mistakes = error.errors()
    places = [mistake["loc"] for mistake in mistakes]
    return [
        f"{source}: {_explain(mistake)}"
        for mistake in mistakes
        if not (mistake["type"] == "too_short" and _has_inner(mistake["loc"], places))
    ]


def _has_inner(place: Sequence[Any], places: Iterable[Sequence[Any]]) -> bool:
    """Whether an entry of this list is itself wrong, which is why the list seems too short."""
    return any(len(other) > len(place) and other[: len(place)] == place for other in places)


def _explain(mistake: ErrorDetails) -> str:
    path, section = _locate(mistake["loc"])
    key = ".".join(map(str, path))
    value, kind = mistake["input"], mistake["type"]
    shown = f"{key} = {_show(value)}"
    if kind == "missing":
        return f"{key}: missing{_purpose(section, str(path[-1]))}"
    if kind == "extra_forbidden":
        return f"{shown}: unknown key; {_nearest(str(path[-1]), section)}"
    if kind == "value_error":
        return _own_check(key, value, str(mistake["ctx"]["error"]))
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return _loss_model(key, value)
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return f"{shown}: should be a table{_table_example(path)}"
    message = mistake["msg"].replace("Input should", "should")
    return f"{shown}: {_REMEDIES.get(kind, message[0].lower() + message[1:])}"


def _locate(place: Sequence[Any]) -> tuple[list[Any], type[BaseModel] | None]:
    """The key's path, and the section that it lies in.

    Pydantic names the chosen loss model within the path; it is no key of the file.
    """
    path = list(place)
    if tuple(path[:2]) == _LOSS and len(path) > 3:
        loss = _LOSSES.get(str(path.pop(2)))
        return path, loss
    section: type[BaseModel] | None = Scenario
    for part in path[:-1]:
        field = section.model_fields.get(str(part)) if section else None
        section = _section_of(field)
    return path, section


def _section_of(field: FieldInfo | None) -> type[BaseModel] | None:
    kind = field.annotation if field is not None else None
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _own_check(key: str, value: Any, message: str) -> str:
    """A section's own check says ``inner key: what is wrong``."""
    inner, colon, rest = message.partition(": ")
    if not colon:
        return f"{key}: {message}"
    path = f"{key}.{inner}" if key else inner
    for part in inner.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return f"{path}: {rest}"
        value = value[part]
    return f"{path} = {_show(value)}: {rest}"


def _loss_model(key: str, value: Any) -> str:
    known = ", ".join(_LOSSES)
    if not isinstance(value, Mapping) or "model" not in value:
        return f"{key}.model: missing; one of {known}"
    close = difflib.get_close_matches(str(value["model"]), _LOSSES, n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    return f"{key}.model = {_show(value['model'])}: must be one of {known}{hint}"


def _table_example(path: Sequence[Any]) -> str:
    if tuple(path) == _LOSS:
        return ', e.g. { model = "bernoulli", probability = 0.8 }'
    return f", [{'.'.join(map(str, path))}]"


def _purpose(section: type[BaseModel] | None, key: str) -> str:
    """What a missing key is for."""
    field = section.model_fields.get(key) if section is not None else None
    inner = _section_of(field)
    text = (inner.__doc__ if inner is not None else field.description if field else None) or ""
    purpose = " ".join(text.split("\n\n")[0].split()).rstrip(".")
    return f" ({purpose[0].lower()}{purpose[1:]})" if purpose else ""


def _nearest(key: str, section: type[BaseModel] | None) -> str:
    known = sorted(section.model_fields) if section is not None else []
    close = difflib.get_close_matches(key, known, n=1)
    return f"did you mean {close[0]}?" if close else f"the keys here are {', '.join(known)}"


def _show(value: Any) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
