"""What all settings are made of: their numbers and descriptions."""

import inspect
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import pytest

from netem.core import settings_section as section_module
from netem.core.settings_section import ScenarioSection
from netem.links_file import LinksFile
from noack.scenario.scenario import Scenario


def real_numbers(schema: Any) -> Iterator[Any]:
    if isinstance(schema, dict):
        if schema.get("type") == "float":
            yield schema
        schema = list(schema.values())
    if isinstance(schema, list | tuple):
        for part in schema:
            yield from real_numbers(part)


@pytest.mark.parametrize("file", [Scenario, LinksFile])
def test_no_setting_accepts_infinity_or_nan(file: type[ScenarioSection]) -> None:
    """The JSON Schema cannot express it."""
    file.model_rebuild()
    schemas = list(real_numbers(file.__pydantic_core_schema__))
    assert len(schemas) > 20
    assert {schema.get("allow_inf_nan") for schema in schemas} == {False}


def test_sections_without_their_source_have_no_descriptions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(inspect, "getsource", Mock(side_effect=OSError("no source")))
    assert section_module._docstrings.__wrapped__("noack.scenario.scenario") == {}
