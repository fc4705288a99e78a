"""What becomes of each key of a scenario: it is used, or irrelevant for a statement, or refused.

``keys.toml`` has the table. A key that is not in it is refused.
"""

import json
import tomllib
from collections.abc import Container, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

Table = Mapping[str, object]
_SHOWN = 60
"""Most characters of a value in a message."""


class KeyRow(NamedTuple):
    """A row of a table of keys."""

    use: str  # "used", "irrelevant" or "refused"
    reason: str
    unless: tuple[object, ...]
    """Values with which a refused key changes nothing; of a list, each entry is one of them."""
    of: tuple[str, ...]
    """The statements in which the key is refused; in all others it is used. Empty: in all."""


class KeyTable:
    """A table of keys, from a TOML file: by key, or by ``table.*`` for all keys of a table."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, list[KeyRow]] = {}
        for use, groups in tomllib.loads(path.read_text(encoding="utf-8")).items():
            for group in groups:
                unless, of = tuple(group.get("unless", ())), tuple(group.get("of", ()))
                for key in group["keys"]:
                    self.rows.setdefault(key, []).append(KeyRow(use, group.get("reason", ""), unless, of))

    def rows_of(self, key: str) -> Sequence[KeyRow]:
        """Return the rows of a key such as ``trigger.beta``; empty: there is none.

        A rule that another one contains has the keys of a trigger: ``trigger.rule.beta`` is ``trigger.beta``.
        """
        while key.startswith("trigger.rule."):
            key = "trigger." + key.removeprefix("trigger.rule.")
        parts = key.split(".")
        names = [key, *(".".join(parts[:count]) + ".*" for count in range(1, len(parts) + 1))]
        return next((self.rows[name] for name in names if name in self.rows), [])

    def refusals(self, resolved: Table, of: Container[str] = ()) -> Iterator[tuple[str, str]]:
        """Yield the keys of a resolved scenario that some statements do not cover, each with a line."""
        for key, value in self._entries(resolved):
            rows = self.rows_of(key)
            if not rows:
                yield key, f"{key}: no statement covers this key"
            for row in rows:
                is_asked = not row.of or any(statement in of for statement in row.of)
                if row.use == "refused" and is_asked and not _is_harmless(value, row.unless):
                    yield key, f"{key} = {_shown(value)}: {row.reason}"

    def _entries(self, table: Table, prefix: str = "") -> Iterator[tuple[str, object]]:
        """Yield the keys of all tables with their values; those of a list of tables without numbers."""
        for key, value in table.items():
            name = f"{prefix}{key}"
            entries = value if isinstance(value, list) else [value]
            tables = [entry for entry in entries if isinstance(entry, Mapping)]
            if not value and isinstance(value, Mapping | list):
                if not self._has_keys(name):
                    yield name, value
            elif len(tables) == len(entries):
                for entry in tables:
                    yield from self._entries(entry, f"{name}.")
            else:
                yield name, value

    def _has_keys(self, name: str) -> bool:
        """Return whether the table has a key of this name, or within it."""
        return bool(self.rows_of(name)) or any(key.startswith(f"{name}.") for key in self.rows)


@cache
def key_table() -> KeyTable:
    """Return the table of the statements of witnesses."""
    return KeyTable(Path(__file__).with_name("keys.toml"))


def refusals(resolved: Table, *, has_equations: bool = False) -> list[str]:
    """Return a line for each key of a resolved scenario that no statement of a witness covers.

    ``has_equations``: the equations of the plant are known.
    """
    knows_state = _get(resolved, "network", "initial_sync") == "known_state"
    harmless = ["controller.safe_input"] if knows_state else []  # it is never applied
    of = () if has_equations else ("linear",)
    found = [line for key, line in key_table().refusals(resolved, of) if key not in harmless]
    if _get(resolved, "network", "impairments") and _get(resolved, "certificate", "network_delay_s") is None:
        found.append("certificate.network_delay_s: state the largest delay of updates in the network")
    return found


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
