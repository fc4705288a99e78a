"""The table of keys and the schema of scenario files have the same keys."""

from collections.abc import Iterator

import pytest

from noack.scenario.scenario import Scenario
from noack.scenario.toml_file import json_schema
from noack.settings.section import Table
from noack_check.keys import refusals, row_of, rows
from tests.helpers.resolved_tables import resolved_tables

SCHEMA = json_schema(Scenario)


def keys_of(schema: Table, prefix: str = "") -> Iterator[str]:
    """Yield the keys of a table, and of the tables within; the rule in a trigger is one key."""
    while "$ref" in schema:
        schema = SCHEMA["$defs"][str(schema["$ref"]).rpartition("/")[2]]  # type: ignore[index]
    kinds = [kind for name in ("anyOf", "oneOf", "allOf") for kind in schema.get(name, [])]  # type: ignore[attr-defined]
    if isinstance(items := schema.get("items"), dict):
        kinds.append(items)
    for kind in kinds:
        yield from keys_of(kind, prefix)
    properties = schema.get("properties", {})
    assert isinstance(properties, dict)
    for name, value in properties.items():
        within = [] if f"{prefix}{name}" == "trigger.rule" else list(keys_of(value, f"{prefix}{name}."))
        yield from within or [f"{prefix}{name}"]


KEYS = sorted(set(keys_of(SCHEMA)) - {"trigger.rule"})


def test_each_key_of_the_schema_is_in_the_table() -> None:
    assert len(KEYS) > 300
    assert [key for key in KEYS if row_of(key) is None] == []


def test_each_key_of_the_table_is_in_the_schema() -> None:
    for name in rows():
        inner = name.removesuffix(".*")
        assert any(key == inner or (name != inner and key.startswith(f"{inner}.")) for key in KEYS), name


def test_each_row_says_why() -> None:
    assert {row.use for row in rows().values()} == {"used", "irrelevant", "refused"}
    for name, row in rows().items():
        assert (row.reason == "") == (row.use == "used"), name


def test_a_key_that_is_not_in_the_table_is_refused_by_its_name() -> None:
    tables = resolved_tables("double_integrator")
    assert refusals(tables) == []
    assert refusals(tables | {"leap_seconds": []}) == ["leap_seconds: unknown to the checker"]
    plant = {**tables["plant"], "mood": {"is": "good"}}
    assert refusals(tables | {"plant": plant}) == ["plant.mood.is: unknown to the checker"]


def test_a_key_of_a_rule_within_a_rule_is_that_of_a_trigger() -> None:
    assert row_of("trigger.rule.rule.beta") is row_of("trigger.beta")
    assert row_of("trigger.rule.gamma") is None


REFUSED = {
    'observer={kind="luenberger", poles_per_s=[-3, -4]}': "observer.",
    "plant.measurement.noise_std=[0.1, 0.0]": "plant.measurement.noise_std",
    'plant.disturbances=[{kind="gaussian", std=[0.1]}]': "plant.disturbances.kind",
    'trigger={policy="dwell", interval_s=0.1, rule={policy="absolute", delta=0.1}}': "trigger.policy",
    'trigger={policy="deadline", interval_s=1.0, rule={policy="dwell", interval_s=0.1, '
    'rule={policy="absolute", delta=0.1}}}': "trigger.rule.policy",
    'trigger={policy="send_on_area", delta_s=0.1}': "trigger.policy",
    "controller.safe_input=[1.0]": "controller.safe_input",
    "controller.predictions=3": "controller.predictions",
    "controller.update_timeout_s=1.0": "controller.update_timeout_s",
    "network.protocol=ack": "network.protocol",
    "network.actuation.mansd=1": "network.actuation.mansd",
    'network.impairments=[{kind="rate", rate_bps=1000000}]': "certificate.network_delay_s",
}


@pytest.mark.parametrize("setting", REFUSED)
def test_what_no_statement_covers_is_refused(setting: str) -> None:
    found = refusals(resolved_tables("double_integrator", setting))
    assert found
    assert found[0].startswith(REFUSED[setting])


@pytest.mark.parametrize(
    "settings",
    [
        ("plant.measurement.noise_std=[0.0, 0.0]",),
        ("controller.safe_input=[0.0]",),
        ("controller.safe_input=[1.0]", "network.initial_sync=known_state"),
        ("changes=[{at_s=1.0, set={'network.loss.probability'=0.9}}]",),
        ('network.impairments=[{kind="rate", rate_bps=1000000}]', "certificate.network_delay_s=0.1"),
        ('trigger={policy="deadline", interval_s=1.0, rule={policy="absolute", delta=0.1}}',),
    ],
)
def test_what_changes_nothing_is_not_refused(settings: tuple[str, ...]) -> None:
    assert refusals(resolved_tables("double_integrator", *settings)) == []
