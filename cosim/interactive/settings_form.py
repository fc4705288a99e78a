"""A form with a field for every key of a scenario.

It follows the JSON schema, in groups as its tables: it names no key, so that a new key of
the schema has its field at once. A table with kinds (``trigger.policy``, ``network.loss.model``) has
a choice, and the fields of its kind.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from cosim.interactive.scenario_draft import Draft, DraftError, Mistake, value_text
from cosim.interactive.sliders import example_of
from noack.core.errors import NoackError
from noack.scenario import toml_file
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import value_of

Schema = Mapping[str, Any]
_VALUE = re.compile(r'^(?: = (?:"(?:[^"\\]|\\.)*"|[^:]*))?: ')
"""What precedes the reason of a mistake; the field itself shows it."""


class FieldKind(StrEnum):
    """How a field is filled in."""

    CHOICE = "choice"
    TEXT = "text"
    TOML = "toml"
    """A number, or a list or table on one line."""


@dataclass(frozen=True)
class Field:
    """A key of the scenario, and what is known of it."""

    key: str
    label: str
    help: str
    kind: FieldKind
    default: str
    """As text; empty if there is none."""
    options: tuple[str, ...] = ()
    """Of a CHOICE."""
    selects: str = ""
    """The table whose kind the field chooses; else empty."""

    def text(self, draft: Draft) -> str:
        """Return the value that a draft gives, as text; empty if it gives none."""
        value = draft.value(self.key)
        if value is None:
            return ""
        return value if isinstance(value, str) else value_text(value)

    def value(self, text: str) -> object:
        """Return the value of a text; what is no TOML stays text, so that validation names it."""
        if self.kind is FieldKind.TEXT:
            return text
        try:
            return value_of(text, self.key)
        except NoackError:
            return text


@dataclass(frozen=True)
class Group:
    """A table of the scenario."""

    key: str
    """Empty for the whole scenario."""
    help: str
    fields: tuple[Field, ...]
    groups: tuple["Group", ...]

    def all_fields(self) -> Iterator[Field]:
        """Yield the fields of this group and of those in it."""
        yield from self.fields
        for group in self.groups:
            yield from group.all_fields()

    def all_groups(self) -> Iterator["Group"]:
        """Yield this group and those in it."""
        yield self
        for group in self.groups:
            yield from group.all_groups()


def form_of(draft: Draft) -> Group:
    """Return the form of a draft, whose kinds decide which fields there are.

    Raises:
        DraftError: the text is not TOML.
    """
    return _group("", _schema(), "", draft.content, {})


def fill_in(draft: Draft, field: Field, text: str) -> Draft:
    """Return the draft with another text in a field; an empty one restores the default.

    Another kind of a table keeps what both kinds have.

    Raises:
        NoackError: a part of the key is no table.
    """
    if not text:
        return draft.without(field.selects or field.key)
    if not field.selects:
        return draft.with_value(field.key, field.value(text))
    with suppress(DraftError):
        if (example := example_of(draft, field.selects, text)) is not None:
            return draft.with_value(field.selects, example)
    changed = draft.with_value(field.key, text)
    group = next(inner for inner in form_of(changed).all_groups() if inner.key == field.selects)
    keys = (*(inner.key for inner in group.fields), *(inner.key for inner in group.groups))
    known = {key.rpartition(".")[2] for key in keys}
    table = changed.value(group.key)
    assert isinstance(table, dict)
    kept = {key: value for key, value in table.items() if key in known}
    return changed.with_value(group.key, kept)


def by_field(form: Group, mistakes: list[Mistake]) -> dict[str, str]:
    """Return the texts of mistakes by the key of the field to which they belong."""
    keys = {field.key for field in form.all_fields()}
    texts: dict[str, str] = {}
    for mistake in mistakes:
        parts = mistake.key.split(".")
        for length in range(len(parts), 0, -1):  # a mistake inside a list belongs to the list
            key = ".".join(parts[:length])
            if key in keys:
                text = _VALUE.sub("", mistake.text.removeprefix(mistake.key))
                texts[key] = "; ".join(filter(None, (texts.get(key), text)))
                break
    return texts


def _schema() -> Schema:
    return toml_file.json_schema(Scenario)


def _resolve(schema: Schema) -> Schema:
    """Return a schema without reference, and without the alternative null."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return {**_schema()["$defs"][name], **{k: v for k, v in schema.items() if k != "$ref"}}
    if "anyOf" in schema:
        alternatives = [alternative for alternative in schema["anyOf"] if alternative.get("type") != "null"]
        if len(alternatives) == 1:
            others = {key: value for key, value in schema.items() if key != "anyOf"}
            return _resolve({**alternatives[0], **others})
    return schema


def _group(key: str, schema: Schema, help_: str, content: object, default: object) -> Group:
    """Return the group of a table: of the kind that the content has, if there are kinds."""
    content = content if isinstance(content, Mapping) else {}
    default = default if isinstance(default, Mapping) else {}
    fields, groups = [], []
    name, kinds = _kinds(schema)
    if kinds:
        optional = [kind for kind, described in kinds.items() if name not in described.get("required", ())]
        usual = default.get(name, optional[0] if len(optional) == 1 else None)
        chosen = content.get(name, usual)
        fields.append(
            Field(f"{key}.{name}", name, help_, FieldKind.CHOICE, _text(usual), tuple(kinds), selects=key)
        )
        schema = kinds.get(chosen, {}) if isinstance(chosen, str) else {}
    for part, described in schema.get("properties", {}).items():
        inner, path = _resolve(described), f"{key}.{part}".removeprefix(".")
        if part == name:
            continue
        value, usual = content.get(part), described.get("default", default.get(part))
        description = str(inner.get("description", ""))
        if "oneOf" in inner or "properties" in inner:
            groups.append(_group(path, inner, description, value, usual))
        else:
            fields.append(_field(path, part, inner, description, usual))
    return Group(key, help_, tuple(fields), tuple(groups))


def _kinds(schema: Schema) -> tuple[str, dict[str, Schema]]:
    """Return the key that chooses the kind, and the schema of each kind; none: there are none."""
    kinds: dict[str, Schema] = {}
    name = ""
    for reference in schema.get("oneOf", ()):
        kind = _resolve(reference)
        name, part = next((name, part) for name, part in kind["properties"].items() if "const" in part)
        kinds[part["const"]] = kind
    return name, kinds


def _field(key: str, label: str, schema: Schema, help_: str, default: object) -> Field:
    options = tuple(map(_text, schema.get("enum", ())))
    kind = FieldKind.CHOICE if options else FieldKind.TOML
    if schema.get("type") == "boolean":
        kind, options = FieldKind.CHOICE, ("true", "false")
    elif schema.get("type") == "string" and not options:
        kind = FieldKind.TEXT
    return Field(key, label, " ".join(help_.split()), kind, _text(default), options)


def _text(value: object) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else value_text(value)
