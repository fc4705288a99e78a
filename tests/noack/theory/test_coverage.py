"""Every key of a scenario has a row in the table of the computed certificates; others are refused."""

from pathlib import Path

import pytest

from cosim.analysis.certificates import certificates_of
from cosim.analysis.claims.run_certificates import scheduled_certificates
from noack.core.errors import CallerError
from noack.theory.certificates.conditions import BOX, OWN_PLANT, REGION, nominal_conditions
from noack.theory.certificates.refusals import refusal_under, refusals_about_reference
from noack.theory.coverage import Statement, key_table, refusal, refusals, require_exact
from tests.helpers.key_tables import faulty_rows, missing_keys, unknown_keys
from tests.helpers.resolved_tables import resolved_tables
from tests.helpers.schema_keys import SCHEMA_KEYS
from tests.helpers.shipped import resolved, shipped

PYTHON = 'kind="python", name="a:B"'


def test_the_table_has_the_keys_of_the_schema() -> None:
    assert missing_keys(key_table()) == unknown_keys(key_table()) == faulty_rows(key_table()) == []


def test_the_page_of_limits_names_each_key_that_is_refused() -> None:
    page = (Path(__file__).parents[3] / "docs" / "limits.md").read_text()
    refused = {name for name, rows in key_table().rows.items() if rows[0].use == "refused"}
    assert {name for name in refused if f"`{name.removesuffix('.*')}`" not in page} == set()


def test_the_statements_of_the_table_are_those_that_are_asked_for() -> None:
    named = {statement for rows in key_table().rows.values() for row in rows for statement in row.of}
    assert named == set(Statement.__args__)  # type: ignore[attr-defined]


def test_a_key_that_is_not_in_the_table_is_refused_by_its_name() -> None:
    tables = resolved_tables("double_integrator")
    assert list(key_table().refusals(tables)) == []
    tables["plant"] |= {"mood": {"is": "good"}}
    lines = [line for _, line in key_table().refusals(tables | {"leap_seconds": []})]
    assert lines == [
        "plant.mood.is: no statement covers this key",
        "leap_seconds: no statement covers this key",
    ]


LINEAR: tuple[Statement, ...] = ("linear",)
WHOLE: tuple[Statement, ...] = ("linear", "whole run")
EXACT: tuple[Statement, ...] = ("exact",)
CHANGES = 'changes=[{at_s=1.0, set={"network.mansd"=1}}]'
LOST = "network.actuation={mansd=1}"
NOISE = "plant.measurement.noise_std=[0.1, 0.0]"
OBSERVER = 'observer={kind="luenberger", poles_per_s=[-3, -4]}'
QUEUE = 'network.impairments=[{kind="rate", rate_bps=1000000}]'
SINE = 'plant.disturbances=[{kind="sine", amplitude=[0.1], hz=1.0}]'


@pytest.mark.parametrize(
    ("settings", "of", "keys"),
    [
        (f"controller={{{PYTHON}}}", (), ["controller.kind"]),
        ("controller.update_timeout_s=1.0", (), ["controller.update_timeout_s"]),
        ("network.protocol=ack", (), ["network.protocol"]),
        ("network.actuation={loss={model=\"bernoulli\", probability=0.1}}", (), ["network.actuation"]),
        (CHANGES, LINEAR, []),
        (CHANGES, WHOLE, ["changes.at_s", "changes.set.network.mansd"]),
        (LOST, LINEAR, []),
        (LOST, EXACT, ["network.actuation"]),
        (SINE, LINEAR, []),
        (SINE, EXACT, ["plant.disturbances.kind"]),
        (NOISE, LINEAR, []),
        (NOISE, EXACT, ["plant.measurement.noise_std"]),
        ("plant.measurement.noise_std=[0.0, 0.0]", EXACT, []),
        (OBSERVER, LINEAR, []),
        (OBSERVER, EXACT, ["observer.kind"]),
        ('trigger={policy="deadline", interval_s=1.0, rule={policy="absolute", delta=0.1}}', EXACT, []),
        ("network.initial_sync=known_state", EXACT, []),
    ],
)  # fmt: skip
def test_what_a_statement_does_not_cover_is_refused_by_its_key(
    settings: str, of: tuple[Statement, ...], keys: list[str]
) -> None:
    found = refusals(resolved("double_integrator", settings), *of)
    assert len(found) >= len(keys)
    assert bool(found) == bool(keys)
    for key, line in zip(keys, found, strict=False):
        assert line.startswith(key)


def test_a_plant_that_is_not_linear_may_have_a_certificate_on_a_region() -> None:
    scenario = resolved("sine_pendulum")
    assert refusals(scenario) == ()
    assert (
        refusal(scenario, "linear")
        == 'plant.system.kind = "python": the plant is not given by matrices A and B'
    )
    with pytest.raises(CallerError, match=r"^plant\.system\.kind = .* this needs a linear plant"):
        require_exact(scenario)


def test_a_plant_that_is_not_linear_has_no_certificate_with_a_load() -> None:
    with pytest.raises(CallerError, match=r'^model\.load: with plant\.system\.kind = "dc_motor" no bound'):
        certificates_of(shipped("dc_motor", 'model.load="input"'), of_model=True)


@pytest.mark.parametrize(
    "settings",
    [
        (
            "description='another text'",
            "model.state_names=['position','v']",
            "speed=2.0",
            "start_within_s=9.0",
        ),
        ("plant.disturbances.0.hz=9.0", "plant.disturbances.0.phase_rad=1.0"),
        ("network.limit=50", "network.encrypted=true", "controller.timeout_input=safe"),
        ("realtime.enabled=false", "clocks={largest_error_us=50.0}", "ports.sensor=4000"),
        ("seeds.loss=5", "seeds.disturbance=6", "seeds.noise=7"),
    ],
)
def test_what_the_table_calls_irrelevant_changes_no_certificate(settings: tuple[str, ...]) -> None:
    before, after = (
        [
            certificate.to_json()
            for certificate in scheduled_certificates(resolved("double_integrator", *given))
        ]
        for given in ((SINE,), (SINE, *settings))
    )
    assert before == after


def test_changes_are_refused_before_a_run_and_not_in_it() -> None:
    with pytest.raises(
        CallerError, match=r"^changes\.at_s = 1\.0: settings must stay the same .*leave changes out"
    ):
        certificates_of(shipped("double_integrator", CHANGES))
    assert scheduled_certificates(resolved("double_integrator", CHANGES))


@pytest.mark.parametrize(
    ("plants", "key", "settings"),
    [
        (OWN_PLANT, "controller.safe_input", ("controller.safe_input=[1.0]", "network.mansd=3")),
        (OWN_PLANT, "certificate.network_delay_s", (QUEUE,)),
        (OWN_PLANT, "plant.watchdog.timeout_s", ("plant.watchdog={policy='zero', timeout_s=0.004}",)),
        (OWN_PLANT, "plant.rate_hz", ("plant.rate_hz=60", NOISE)),
        (BOX, "observer.kind", (OBSERVER,)),
        (REGION, "observer.kind", (OBSERVER,)),
    ],
)  # fmt: skip
def test_a_refusal_from_several_settings_begins_with_a_key(
    plants: str, key: str, settings: tuple[str, ...]
) -> None:
    scenario = resolved("double_integrator", *settings)
    conditions = nominal_conditions(scenario)._replace(start_s=1.0, hold_s=1.0)
    assert key in SCHEMA_KEYS
    assert (refusal_under(conditions, scenario, plants) or "").startswith(key)


def test_a_refusal_at_a_setpoint_begins_with_its_key() -> None:
    scenario = resolved("unstable_pendulum", "controller.setpoint=[0.1, 0.0]")
    found = refusals_about_reference(scenario)
    assert list(found) == [OWN_PLANT, BOX]
    assert all(line.startswith("controller.setpoint: ") for line in found.values())
