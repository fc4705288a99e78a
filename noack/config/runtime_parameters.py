"""What can be changed while a run goes on: keys of the scenario, and short names for them.

A change is a table of keys and values. It is applied to the whole scenario, which is then validated
as one that was read from a file; so nothing can be set that could not be started with.
"""

import json
from collections.abc import Mapping
from types import NoneType
from typing import Any, get_args

from noack.trigger.policy_settings import PolicySettings

LOSS, MANSD, SETPOINT = "network.loss", "network.mansd", "controller.setpoint"

SHORT: Mapping[str, str] = {
    "loss": LOSS,
    "loss.p": f"{LOSS}.probability",
    "mansd": MANSD,
    "beta": "trigger.beta",
    "alpha": "trigger.alpha_per_s",
    "floor": "trigger.floor",
    "setpoint": SETPOINT,
}
"""Short names of keys."""


def full_key(name: str) -> str:
    """Return the scenario's key for a name that may be short, such as ``loss.p``."""
    if name in SHORT:
        return SHORT[name]
    return f"network.{name}" if name.startswith("loss.") else name


def trigger_parameters(trigger: PolicySettings) -> tuple[str, ...]:
    """The keys of a trigger's numbers: policy and norm stay what they are."""
    return tuple(
        f"trigger.{name}"
        for name, field in type(trigger).model_fields.items()
        if name not in trigger.at_start_only and _is_number(field.annotation)
    )


def require_runtime_parameters(settings: Mapping[str, Any], trigger: PolicySettings) -> None:
    """Check that all keys are such as can be changed during a run.

    Args:
        settings: values by keys.
        trigger: the run's.

    Raises:
        ValueError: one is not; the message says which are.
    """
    known = (LOSS, MANSD, *trigger_parameters(trigger), SETPOINT)
    for key, value in settings.items():
        if key not in known and not key.startswith(f"{LOSS}."):
            short = ", ".join(SHORT)
            raise ValueError(
                f"{key}: cannot be changed during a run; what can is {_list(known)} "
                f"(for short: {short})"
            )
        if _has_none(value):
            raise ValueError(f"{key}: needs a value")


def put_settings(content: dict[str, Any], settings: Mapping[str, Any]) -> None:
    """Put settings into the content of a scenario; another loss model begins without keys.

    Args:
        content: of a scenario, as from JSON; changed in place.
        settings: values by keys that :func:`require_runtime_parameters` has let pass.
    """
    model = f"{LOSS}.model"
    if model in settings and settings[model] != content["network"]["loss"].get("model"):
        content["network"]["loss"] = {}
    # A table before the keys in it.
    for key in sorted(settings):
        table = content
        *path, last = key.split(".")
        for part in path:
            inner = table.setdefault(part, {})
            if not isinstance(inner, dict):
                raise ValueError(f"{key}: {part} is not a table")
            table = inner
        table[last] = settings[key]


def is_of_loss_alone(settings: Mapping[str, Any]) -> bool:
    """Whether a change touches nothing that is claimed of a run: what is lost below the cap."""
    return all(key == LOSS or key.startswith(f"{LOSS}.") for key in settings)


def text_of(settings: Mapping[str, Any]) -> str:
    """In words: ``network.mansd = 2, trigger.beta = 0.3``."""
    return ", ".join(f"{key} = {_value(value)}" for key, value in sorted(settings.items()))


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        inner = ", ".join(f"{key} = {_value(one)}" for key, one in value.items())
        return f"{{ {inner} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return f"{value:g}" if abs(value) < 1e300 else "…"  # an integer may be too large for it
    return json.dumps(value)


def _is_number(annotation: Any) -> bool:
    kinds = [one for one in (get_args(annotation) or (annotation,)) if one is not NoneType]
    return all(kind in (int, float) for kind in kinds)


def _has_none(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_has_none, value.values()))
    return any(map(_has_none, value)) if isinstance(value, list | tuple) else value is None


def _list(keys: tuple[str, ...]) -> str:
    return f"{', '.join(keys[:-1])} and {keys[-1]}"
