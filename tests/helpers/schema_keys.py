"""The keys of scenario files, from their JSON Schema."""

from collections.abc import Iterator

from netem.core.settings_section import Table
from netem.core.toml_file import json_schema
from noack.scenario.scenario import Scenario

_SCHEMA = json_schema(Scenario)


def _keys_of(schema: Table, prefix: str = "") -> Iterator[str]:
    """Yield the keys of a table, and of the tables within; the rule in a trigger is one key."""
    while "$ref" in schema:
        schema = _SCHEMA["$defs"][str(schema["$ref"]).rpartition("/")[2]]  # type: ignore[index]
    kinds = [kind for name in ("anyOf", "oneOf", "allOf") for kind in schema.get(name, [])]  # type: ignore[attr-defined]
    if isinstance(items := schema.get("items"), dict):
        kinds.append(items)
    for kind in kinds:
        yield from _keys_of(kind, prefix)
    properties = schema.get("properties", {})
    assert isinstance(properties, dict)
    for name, value in properties.items():
        within = [] if f"{prefix}{name}" == "trigger.rule" else list(_keys_of(value, f"{prefix}{name}."))
        yield from within or [f"{prefix}{name}"]


SCHEMA_KEYS = sorted(set(_keys_of(_SCHEMA)) - {"trigger.rule"})
"""All keys, such as ``plant.disturbances.hz``; those of a rule within a trigger are the trigger's."""
