"""Scenario files that entries of ``[[loops]]`` name; loading a scenario replaces names by tables.

A loop takes the file's mode, model, plant, trigger, observer and controller. What the loops of a
run share is the run's: a file that sets it to something else is refused. Seeds, horizon, speed,
ports, real-time settings and recovery of the file have no effect.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, create_model

from noack.config import toml_file
from noack.config.loops import PARTS
from noack.config.matrix_files import with_matrices
from noack.config.scenario import Scenario
from noack.config.validation_messages import show_value
from noack.core.errors import CallerError, did_you_mean, printable
from noack.core.file_access import shipped_folder
from noack.settings.named_file import file_tables, located, with_tables
from noack.settings.section import ScenarioSection

_SHARED = ("network", "certificate", "clocks", "changes")
"""Keys that a loop's file may set only as the run does."""


def with_named_scenarios(
    content: Mapping[str, Any], folder: Path, source: str
) -> Mapping[str, Any]:
    """Return a scenario's content with the tables of the files that its loops name.

    Names are relative to ``folder``, or those of shipped scenarios. Raise CallerError, with one
    line per mistake, if a file is no scenario of one loop, or does not fit the run.
    """
    if not isinstance(loops := content.get("loops"), list):
        return content
    read = []
    for place, entry in enumerate(loops):
        tables = {}
        if isinstance(entry, dict) and isinstance(name := entry.get("scenario"), str):
            named = printable(f'{source}: loops.{place}.scenario = "{name}"')
            tables = {"scenario": _tables(_path(name, folder, named), content, named)}
        read.append(entry | tables if tables else entry)
    return {**content, "loops": read}


def _tables(path: Path, run: Mapping[str, Any], named: str) -> dict[str, Any]:
    """Return the tables of a loop's file, which the setting ``named`` names."""
    content = toml_file.read(path, Scenario)
    if content.get("loops"):
        raise CallerError(f"{named}: that file has loops itself; name a file of one loop")
    content = with_matrices(content, path.parent, str(path))
    file = toml_file.validated(_file_model(), content, str(path))
    for key in _SHARED:
        _require_equal(key, file, run, named)
    tables = {
        where: located(table, path.parent, f"{path}: {where}") for where, table in file_tables(file)
    }
    parts = set(PARTS)
    return with_tables(file, tables).model_dump(mode="json", exclude_none=True, include=parts)


def _path(name: str, folder: Path, named: str) -> Path:
    """Return the path of a file, or of the shipped scenario of that name."""
    shipped = {file.stem: file for file in shipped_folder("scenarios").glob("*.toml")}
    with suppress(OSError, ValueError):  # too long, or with a zero byte
        if (path := folder / name).exists():
            return path
    if name in shipped:
        return shipped[name]
    names = [*sorted(shipped), *sorted(file.name for file in folder.glob("*.toml"))]
    hint = did_you_mean(name, names) or "`noack scenarios` lists the shipped ones"
    raise CallerError(f"{named}: no such file, nor a shipped scenario; {hint}")


def _require_equal(key: str, file: ScenarioSection, run: Mapping[str, Any], named: str) -> None:
    """Raise CallerError if a file sets a key to something else than the run."""
    own = getattr(file, key)
    if key not in file.model_fields_set or own is None:
        return
    try:
        shared = Scenario.model_fields[key].get_default()
        if key in run:
            shared = _section(key).validate_json(json.dumps(run[key]))
    except (TypeError, ValueError):  # the run's own mistake is reported with its others
        return
    for where, theirs, ours in _pairs(key, own, shared):
        if theirs != ours:
            raise CallerError(
                f"{named}: {where} is {show_value(theirs)} there and {show_value(ours)} in this "
                "run; the loops of a run share it: leave it out of that file, or set the same"
            )


def _pairs(key: str, own: Any, shared: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield what the file sets, and what the run has; of a table, the keys that the file sets."""
    theirs, ours = (TypeAdapter(Any).dump_python(value, mode="json") for value in (own, shared))
    if not isinstance(own, ScenarioSection) or shared is None:
        yield key, theirs, ours
        return
    for inner in type(own).model_fields:
        if inner not in own.model_fields_set:
            continue
        value, other = theirs[inner], ours[inner]
        if isinstance(value, dict) and isinstance(other, dict):
            yield from ((f"{key}.{inner}.{k}", value[k], other.get(k)) for k in value)
        yield f"{key}.{inner}", value, other


@cache
def _section(key: str) -> TypeAdapter[Any]:
    return TypeAdapter(Scenario.model_fields[key].rebuild_annotation())


@cache
def _file_model() -> type[ScenarioSection]:
    """Return the model of a loop's file: a scenario in which all that a run has is optional."""
    fields: dict[str, Any] = {
        name: (field.annotation, field) if name in PARTS else (field.annotation | None, None)
        for name, field in Scenario.model_fields.items()
    }
    return create_model("LoopFile", __base__=ScenarioSection, **fields)
