"""The runtime parameters: keys of the scenario that can be changed during a run, and short names.

A change is a table of keys and values. It is applied to the whole scenario, which is then validated
like a scenario file. So a change can only set values that a run could also start with.
"""

import json
import math
from collections.abc import Callable, Mapping
from types import NoneType
from typing import get_args

from netem.core.errors import CallerError
from netem.core.settings_section import ReadTable, Table
from netem.core.toml_file import nearest_key
from noack.scenario.symbols import SYMBOLS
from noack.trigger_policies.policy_settings import PolicySettings

LOSS, MANSD, SETPOINT = "network.loss", "network.mansd", "controller.setpoint"
CONSTRAINTS = "network.constraints"
_PROBABILITY = f"{LOSS}.probability"

SHORT: Mapping[str, str] = {
    "loss": LOSS,
    "loss.p": _PROBABILITY,
    "mansd": MANSD,
    "constraints": CONSTRAINTS,
    "beta": "trigger.beta",
    "alpha": "trigger.alpha_per_s",
    "floor": "trigger.floor",
    "setpoint": SETPOINT,
}
"""Short names of keys."""


def full_key(name: str) -> str:
    """Return the scenario's key for a name that may be short, such as ``loss.p``.

    Wherever a user names a key, short names are understood: ``noack set``, ``--set``, settings of
    the library and of campaigns, ``[[changes]]``.
    """
    if name in SHORT:
        return SHORT[name]
    return f"network.{name}" if name.startswith("loss.") else name


def trigger_parameters(trigger: PolicySettings) -> tuple[str, ...]:
    """Return the keys of a trigger's numbers; its policy and norm cannot change."""
    return tuple(
        f"trigger.{name}"
        for name, field in type(trigger).model_fields.items()
        if name not in trigger.at_start_only and _is_number(field.annotation)
    )


def require_runtime_parameters(settings: ReadTable, trigger: PolicySettings) -> None:
    """Raise ValueError unless all keys are runtime parameters; the message lists these."""
    allowed = (LOSS, MANSD, CONSTRAINTS, *trigger_parameters(trigger), SETPOINT)
    for key, value in settings.items():
        if key in SYMBOLS:
            raise ValueError(f"{key}: unknown name; {SYMBOLS[key]}")
        if key not in allowed and not key.startswith(f"{LOSS}."):
            short = [name for name, full in SHORT.items() if full in (*allowed, _PROBABILITY)]
            nearest = nearest_key(key, (*short, *allowed, _PROBABILITY))
            hint = nearest and f"did you mean {nearest}?"
            all_known = f"these can: {_in_words(allowed)} (for short: {', '.join(short)})"
            raise ValueError(f"{key}: cannot be changed during a run; {hint or all_known}")
        if _contains(value, lambda entry: entry is None):
            raise ValueError(f"{key}: needs a value")


def require_finite(settings: ReadTable) -> None:
    """Raise CallerError if a value has a number that is not finite, which no message can carry."""
    for key, value in settings.items():
        if _contains(value, lambda entry: isinstance(entry, float) and not math.isfinite(entry)):
            raise CallerError(f"{key} = {_text(value)}: expected a finite number")


def put_settings(content: Table, settings: ReadTable) -> None:
    """Write checked settings into a scenario's content; a new loss model replaces all its keys."""
    if (model := f"{LOSS}.model") in settings:
        network = _inner_table(content, "network", model)
        if settings[model] != _inner_table(network, "loss", model).get("model"):
            network["loss"] = {}
    # A table before the keys in it.
    for key in sorted(settings):
        table = content
        *path, last = key.split(".")
        for part in path:
            table = _inner_table(table, part, key)
        table[last] = settings[key]


def _inner_table(table: Table, part: str, key: str) -> Table:
    inner = table.setdefault(part, {})
    if not isinstance(inner, dict):
        raise ValueError(f"{key}: {part} is not a table")
    return inner


def is_of_loss_alone(settings: ReadTable) -> bool:
    """Whether a change concerns the loss model only, on which no claim about the run depends."""
    return all(key == LOSS or key.startswith(f"{LOSS}.") for key in settings)


def text_of(settings: ReadTable) -> str:
    """Return settings as text: ``network.mansd = 2, trigger.beta = 0.3``."""
    return ", ".join(f"{key} = {_text(value)}" for key, value in sorted(settings.items()))


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        inner = ", ".join(f"{key} = {_text(entry)}" for key, entry in value.items())
        return f"{{ {inner} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "…" if isinstance(value, int) and abs(value) > 10**300 else f"{value:g}"  # no float
    return json.dumps(value)


def _is_number(annotation: object) -> bool:
    kinds = [kind for kind in (get_args(annotation) or (annotation,)) if kind is not NoneType]
    return all(kind in (int, float) for kind in kinds)


def _contains(value: object, matches: Callable[[object], bool]) -> bool:
    inner = [*value.values()] if isinstance(value, Mapping) else value
    if isinstance(inner, list | tuple):
        return any(_contains(entry, matches) for entry in inner)
    return matches(value)


def _in_words(keys: tuple[str, ...]) -> str:
    return f"{', '.join(keys[:-1])} and {keys[-1]}"
