"""Shell completion: names of shipped files, run directories, keys of a scenario."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from cosim.record.run_directory import DEFAULT_RUNS, LATEST, SCENARIO_FILE
from cosim.shipped_files import shipped_names

if TYPE_CHECKING:
    from pydantic import BaseModel


def scenarios(incomplete: str) -> list[str]:
    """Return matching names of shipped scenarios; the shell completes file names itself."""
    return _matching(incomplete, shipped_names("scenarios"))


def campaigns(incomplete: str) -> list[str]:
    """Return matching names of shipped campaigns."""
    return _matching(incomplete, shipped_names("campaigns"))


def shipped(incomplete: str) -> list[str]:
    """Return matching names of shipped scenarios and campaigns."""
    return scenarios(incomplete) + campaigns(incomplete)


def run_directories(incomplete: str) -> list[str]:
    """Return matching run directories below ``runs``, the newest first."""
    found = [path.parent for path in DEFAULT_RUNS.glob(f"*/{SCENARIO_FILE}")]
    by_name = sorted(found, key=lambda path: (path.name == LATEST, path.name), reverse=True)
    return _matching(incomplete, [str(path) for path in by_name])


def settings(incomplete: str) -> list[str]:
    """Return matching keys for ``--set``, each with its =."""
    from noack.config.scenario import Scenario

    return _matching(incomplete, [f"{key}=" for key in keys(Scenario)])


def runtime_parameters(incomplete: str) -> list[str]:
    """Return matching short names of the runtime parameters."""
    from noack.config.runtime_parameters import SHORT

    return _matching(incomplete, list(SHORT))


def keys(section: "type[BaseModel]", prefix: str = "") -> list[str]:
    """Return the keys of a settings file, each once; of a union of tables, the keys of all."""
    return list(dict.fromkeys(_keys(section, prefix, ())))


def _keys(
    section: "type[BaseModel]", prefix: str, within: "tuple[type[BaseModel], ...]"
) -> Iterator[str]:
    from noack.config.validation_messages import sections_of

    for name, field in section.model_fields.items():
        inner = [one for one in sections_of(field.annotation) if one not in within]
        for one in inner:  # a trigger may contain another
            yield from _keys(one, f"{prefix}{name}.", (*within, *inner))
        if not inner:
            yield f"{prefix}{name}"


def _matching(incomplete: str, words: list[str]) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]
