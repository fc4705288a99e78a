"""What becomes of each key of a scenario: it is used, or irrelevant for a statement, or refused.

``keys.toml`` has the table. A key that is not in it is refused.
"""

import json
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

Table = Mapping[str, object]
_SHOWN = 60
"""Most characters of a value in a message."""


class RefusedError(ValueError):
    """No statement covers the scenario; the message is one line that names the key."""


class Row(NamedTuple):
    """A row of the table of keys."""

    use: str  # "used", "irrelevant" or "refused"
    reason: str
    unless: tuple[object, ...]
    """Values with which a refused key changes nothing; of a list, each entry is one of them."""


@cache
def rows() -> Mapping[str, Row]:
    """Return the table: by key, or by ``table.*`` for all keys of a table."""
    content = tomllib.loads(Path(__file__).with_name("keys.toml").read_text(encoding="utf-8"))
    found: dict[str, Row] = {}
    for use, groups in content.items():
        for group in groups:
            row = Row(use, group.get("reason", ""), tuple(group.get("unless", ())))
            for key in group["keys"]:
                if key in found:
                    raise ValueError(f"keys.toml: {key} is there twice")
                found[key] = row
    return found


def row_of(key: str) -> Row | None:
    """Return the row of a key such as ``trigger.beta``; None: there is none.

    A rule that another one contains has the keys of a trigger: ``trigger.rule.beta`` is ``trigger.beta``.
    """
    while key.startswith("trigger.rule."):
        key = "trigger." + key.removeprefix("trigger.rule.")
    parts = key.split(".")
    names = [key, *(".".join(parts[:count]) + ".*" for count in range(1, len(parts) + 1))]
    return next((rows()[name] for name in names if name in rows()), None)


def refusals(resolved: Table) -> list[str]:
    """Return a line for each key of a resolved scenario that no statement covers."""
    knows_state = _get(resolved, "network", "initial_sync") == "known_state"
    found = []
    for key, value in _entries(resolved):
        row = row_of(key)
        if row is None:
            found.append(f"{key}: unknown to the checker")
        elif key == "controller.safe_input" and knows_state:
            continue  # it is never applied
        elif row.use == "refused" and not _is_harmless(value, row.unless):
            found.append(f"{key} = {_shown(value)}: {row.reason}")
    if _get(resolved, "network", "impairments") and _get(resolved, "certificate", "network_delay_s") is None:
        found.append("certificate.network_delay_s: state the largest delay of updates in the network")
    return found


def _entries(table: Table, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yield the keys of all tables with their values; those of a list of tables without numbers."""
    for key, value in table.items():
        name = f"{prefix}{key}"
        entries = value if isinstance(value, list) else [value]
        tables = [entry for entry in entries if isinstance(entry, Mapping)]
        if not value and isinstance(value, Mapping | list):
            if not _has_keys(name):
                yield name, value
        elif len(tables) == len(entries):
            for entry in tables:
                yield from _entries(entry, f"{name}.")
        else:
            yield name, value


def _has_keys(name: str) -> bool:
    """Return whether the table of keys has a key of this name, or within it."""
    return row_of(name) is not None or any(key.startswith(f"{name}.") for key in rows())


def _is_harmless(value: object, unless: tuple[object, ...]) -> bool:
    if isinstance(value, list) and value:
        return all(_is_harmless(entry, unless) for entry in value)
    return value in unless


def _get(resolved: Table, table: str, key: str) -> object:
    content = resolved.get(table)
    return content.get(key) if isinstance(content, Mapping) else None


def _shown(value: object) -> str:
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"
