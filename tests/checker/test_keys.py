"""The table of keys and the schema of scenario files have the same keys."""

import pytest

from noack.proof.elaborate.keys import key_table, refusals
from tests.helpers.key_tables import faulty_rows, missing_keys, unknown_keys
from tests.helpers.resolved_tables import resolved_tables
from tests.helpers.schema_keys import SCHEMA_KEYS


def test_the_table_has_the_keys_of_the_schema() -> None:
    assert len(SCHEMA_KEYS) > 300
    assert missing_keys(key_table()) == unknown_keys(key_table()) == faulty_rows(key_table()) == []


def test_a_key_that_is_not_in_the_table_is_refused_by_its_name() -> None:
    tables = resolved_tables("double_integrator")
    assert refusals(tables) == []
    assert refusals(tables | {"leap_seconds": []}) == ["leap_seconds: no statement covers this key"]
    plant = {**tables["plant"], "mood": {"is": "good"}}
    assert refusals(tables | {"plant": plant}) == ["plant.mood.is: no statement covers this key"]


def test_a_key_of_a_rule_within_a_rule_is_that_of_a_trigger() -> None:
    assert key_table().rows_of("trigger.rule.rule.beta") is key_table().rows_of("trigger.beta")
    assert key_table().rows_of("trigger.rule.gamma") == []


REFUSED = {
    "network.protocol=ack": "network.protocol",
    "controller.safe_input=[1.0]": "controller.safe_input",
    "controller.update_timeout_s=1.0": "controller.update_timeout_s",
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
        ("network.actuation.mansd=1", "controller.predictions=3"),
        ("controller.safe_input=[1.0]", "network.initial_sync=known_state"),
        ("changes=[{at_s=1.0, set={'network.loss.probability'=0.9}}]",),
        ('network.impairments=[{kind="rate", rate_bps=1000000}]', "certificate.network_delay_s=0.1"),
        ('trigger={policy="deadline", interval_s=1.0, rule={policy="absolute", delta=0.1}}',),
        ('trigger={policy="dwell", interval_s=0.1, rule={policy="absolute", delta=0.1}}',),
    ],
)
def test_what_changes_nothing_is_not_refused(settings: tuple[str, ...]) -> None:
    assert refusals(resolved_tables("double_integrator", *settings)) == []
