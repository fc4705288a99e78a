"""Settings and tables that a program gives, as if they came from a TOML file."""

from collections.abc import Mapping

import numpy as np

from netem.core.errors import CallerError
from netem.core.settings_section import ReadTable, Table


def given_settings(settings: ReadTable | None) -> list[tuple[str, object]]:
    """Return the keys and plain values of settings; raise CallerError if they are not a table."""
    if not isinstance(settings, Mapping | None):
        raise CallerError(
            f"settings: {settings!r} is not a table; give values by key, "
            'e.g. {"network.loss.probability": 0.8}'
        )
    for key in settings or {}:
        if not isinstance(key, str):
            raise CallerError(f'settings: {key!r} is not a key; a key is a text such as "trigger.beta"')
    return [(key, plain(value)) for key, value in (settings or {}).items()]


def plain_table(table: ReadTable) -> Table:
    """Return a table as from a TOML parser: NumPy arrays and numbers become lists and numbers."""
    return {str(key): plain(entry) for key, entry in table.items()}


def plain(value: object) -> object:
    """Return a value as from a TOML parser, as :func:`plain_table` does."""
    if isinstance(value, Mapping):
        return plain_table(value)
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value
