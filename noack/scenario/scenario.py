"""The scenario: everything that defines a run, validated into frozen objects; and its loops.

A scenario file is TOML; every key is documented in its table, and in the exported JSON Schema.
Unknown keys are errors. :mod:`noack.scenario.resolution` replaces names and random draws by
numbers.

A run has one or more loops on one network, each an ordinary scenario. The number of a loop is its
place in :func:`loops_of`. A loop begins at its phase: its time 0 is that time of the run.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from typing import Any, Self

import numpy as np
from pydantic import ConfigDict, GetJsonSchemaHandler, ValidationError, create_model, model_validator
from pydantic_core import CoreSchema

from netem.core.random_streams import named_stream_keys
from netem.core.settings_section import ReadTable, ScenarioSection, Table
from netem.core.toml_file import explain
from noack.scenario.run_sections import MOST_LOOPS, LoopSection, SeedsSection
from noack.scenario.scenario_checks import check_changes, check_sections
from noack.scenario.scenario_tables import ScenarioTables
from noack.scenario.symbols import ScenarioRoot


class Scenario(ScenarioTables):
    """A run of the loop, completely described: the tables and keys of ``docs/scenarios.md``.

    Matrices are tuples of rows; times are in seconds, those of ``timing`` in nanoseconds.

    >>> import noack
    >>> scenario = noack.load("lane_following")
    >>> scenario.trigger.beta, scenario.network.mansd, scenario.timing.plant_period_ns
    (0.5, 4, 2000000)
    """

    model_config = ConfigDict(json_schema_extra={"description": "A run of the loop, completely described."})

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_sections(self)
        check_changes(self)
        check_loops(self)
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler, /) -> Table:
        """Return the JSON Schema; a scenario whose loops all have a file needs no tables of a loop."""
        schema = super().__get_pydantic_json_schema__(core_schema, handler)
        resolved_schema = handler.resolve_ref_schema(schema)
        resolved_schema["required"] = [key for key in resolved_schema["required"] if key not in LOOP_NEEDS]
        resolved_schema["anyOf"] = [{"required": ["loops"]}, {"required": [*LOOP_NEEDS]}]
        return schema


PARTS = ("mode", "model", "plant", "trigger", "observer", "controller", "outputs")
"""Keys of a scenario that each loop has for itself."""
LOOP_NEEDS = ("model", "plant", "trigger")
"""Those without which there is no loop."""
_KINDS: Mapping[str, tuple[str, ...]] = {
    "model": ("name", "A", "file"),
    "plant": (),
    "trigger": ("policy",),
    "observer": ("kind",),
    "controller": ("kind",),
}
"""The tables of a loop, each with the keys that make it replace the table of the top level."""
_MOST_NAMES = 12
"""Names of loops that a message lists."""
_DRAWN = ("plant", "initial_state", "disturbance", "noise")
"""The seeds that each loop has of its own."""


def loop_sections(scenario: Scenario) -> tuple[LoopSection, ...]:
    """Return the entries of [[loops]]; a scenario without has one, which changes nothing."""
    return scenario.loops or (LoopSection(name=scenario.name),)


def loop_names(scenario: Scenario) -> list[str]:
    """Return the names of the loops, in the order of their numbers."""
    return [name for section in loop_sections(scenario) for name in section.names]


def loops_of(scenario: Scenario) -> tuple[Scenario, ...]:
    """Return one scenario per loop, not yet resolved.

    The first loop has the seeds of the run; those of the others are drawn from these and the loop's
    number. So a run with one entry of [[loops]] computes what the run without it does.
    """
    return tuple(loop for loops in loops_by_entry(scenario) for loop in loops)


def few_of(names: Sequence[str]) -> str:
    """Return the names of loops in words, at most twelve."""
    return ", ".join(names[:_MOST_NAMES]) + (", …" if len(names) > _MOST_NAMES else "")


def loops_by_entry(scenario: Scenario) -> list[list[Scenario]]:
    """Return the loops of each entry of [[loops]]; they differ in their names and seeds only."""
    seeds = iter(loop_seeds(scenario))
    return [
        [entry.model_copy(update={"name": name, "seeds": next(seeds)}) for name in section.names]
        for section in loop_sections(scenario)
        for entry in [loop_scenario(scenario, section)]
    ]


def with_loop_tables(
    scenario: Scenario, change: Callable[[str, Scenario], Mapping[str, ScenarioSection]]
) -> Scenario:
    """Return a scenario with other tables in the entries of [[loops]].

    ``change`` gets the place of an entry, e.g. ``loops.0``, and the scenario of its loops. It
    returns the new tables by their places, e.g. ``plant.system``; only those of tables that the
    entry sets itself, or that its scenario file has, are used.
    """
    sections = []
    for index, section in enumerate(scenario.loops or ()):
        update: Table = {}
        file = section.scenario if isinstance(section.scenario, dict) else {}
        changed = change(f"loops.{index}", loop_scenario(scenario, section))
        for path, table in changed.items():
            part, _, inner = path.partition(".")
            content = table.content()
            if (entry_table := getattr(section, part)) is not None and (not inner or inner in entry_table):
                update[part] = entry_table | {inner: content} if inner else content
            elif part in file:
                in_file = file[part]
                new_table = in_file | {inner: content} if inner and isinstance(in_file, dict) else content
                update["scenario"] = file = {**file, part: new_table}
        sections.append(section.model_copy(update=update))
    return scenario.model_copy(update={"loops": tuple(sections) or None})


def loop_scenario(scenario: Scenario, section: LoopSection) -> Scenario:
    """Return the scenario of an entry of [[loops]], with the seeds of the run.

    Raises:
        ValueError: it is not valid; the message begins with the key within the entry.
    """
    loop = scenario.model_copy(update={"loops": None})
    if isinstance(section.scenario, str):
        raise ValueError("scenario: it is read where a scenario file is loaded; give tables here")
    if section.scenario is not None:
        loop = _with_parts(loop, section.scenario, PARTS, "scenario.")
    content: Table = {} if section.mode is None else {"mode": section.mode}
    if section.outputs is not None:
        content["outputs"] = section.outputs
    for part, kinds in _KINDS.items():
        if (entry_table := getattr(section, part)) is None:
            continue
        base_section = getattr(loop, part)
        template = {} if base_section is None else base_section.content()
        content[part] = entry_table if any(kind in entry_table for kind in kinds) else template | entry_table
    if content:
        loop = _with_parts(loop, content, content)
    if content or section.scenario is not None:
        check_sections(loop)
        check_changes(loop)
    return loop


def _with_parts(scenario: Scenario, content: ReadTable, parts: Iterable[str], place: str = "") -> Scenario:
    """Return a scenario with other parts; raise ValueError, after the place, if one is invalid."""
    model = parts_model(frozenset(parts))
    try:
        validated = model.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise ValueError(place + explain(error, "", model)[0].removeprefix(": ")) from None
    return scenario.model_copy(update={part: getattr(validated, part) for part in parts})


def check_loops(scenario: Scenario) -> None:
    """Raise ValueError unless the loops can run together; the message begins with the key."""
    names: dict[str, int] = {}
    for index, section in enumerate(scenario.loops or ()):
        try:
            loop_scenario(scenario, section)
        except ValueError as error:
            raise ValueError(f"loops.{index}.{error}") from None
        for name in section.names:
            if name in names:
                raise ValueError(
                    f"loops.{index}.name: the name {name} is already given by loops.{names[name]}"
                )
            names[name] = index
        if len(names) > MOST_LOOPS:
            raise ValueError(f"loops.{index}.count: a run has at most {MOST_LOOPS} loops")


def loop_seeds(scenario: Scenario, drawn_names: Sequence[str] = _DRAWN) -> list[SeedsSection]:
    """Return the seeds of each loop; those of the given names are the loop's own."""
    sections = loop_sections(scenario)
    seeds, count = scenario.seeds, sum(section.count for section in sections)
    drawn: list[dict[str, int]] = [{}]
    if count > 1:
        names = [("loop", str(number), name) for number in range(1, count) for name in drawn_names]
        keys = named_stream_keys([getattr(seeds, name) for *_, name in names], names)
        low, high = keys.astype(np.uint64).T
        bits = (low | high << np.uint64(32)) >> np.uint64(1)  # 63, the range of a TOML integer
        by_loop = bits.reshape(-1, len(drawn_names)).tolist()
        drawn += [dict(zip(drawn_names, values, strict=True)) for values in by_loop]
    all_seeds: list[SeedsSection] = []
    for section in sections:
        entry_seeds = section.seeds.model_dump(exclude_none=True)
        drawn_seeds = drawn[len(all_seeds) : len(all_seeds) + section.count]
        all_seeds += [seeds.model_copy(update=values | entry_seeds) for values in drawn_seeds]
    return all_seeds


@cache
def parts_model(parts: frozenset[str], *, others_optional: bool = False) -> type[ScenarioSection]:
    """Return a model of a scenario's parts; with ``others_optional`` the others are optional keys."""
    fields: dict[str, Any] = {}
    for name, field in Scenario.model_fields.items():
        kind: Any = field.annotation
        if name in parts:
            fields[name] = (kind, field)
        elif others_optional:
            fields[name] = (kind | None, None)
    model: type[ScenarioSection] = create_model("LoopParts", __base__=ScenarioRoot, **fields)
    return model
