"""Changes of runtime parameters: what is refused, what stays, and their order in time."""

import json
from pathlib import Path
from typing import Any

import pytest

from netem.core.errors import CallerError
from netem.impairments.loss_models.bernoulli import BernoulliLoss
from netem.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.protocol.record_tables import CHANGE_BYTES
from noack.scenario.parameter_changes import (
    ChangeSchedule,
    ParameterChange,
    changed,
    settings_bytes,
    settings_of,
)
from noack.scenario.resolution import resolve
from noack.scenario.runtime_parameters import is_of_loss_alone, text_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.helpers.approved import compare_lines, lines_of_error


@pytest.fixture
def scenario(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "here"))


def test_an_invalid_change_is_refused_with_the_approved_line(scenario: Scenario) -> None:
    compare_lines(
        Path(__file__).with_name("change_mistakes.txt"),
        lambda settings: lines_of_error(lambda: changed(scenario, json.loads(settings))),
    )
    script = {"network.loss": {"model": "scripted", "lost": list(range(900))}}
    with pytest.raises(CallerError, match=r"^[^\n]*at most 1024[^\n]*$"):
        changed(scenario, script)


def test_a_change_leaves_all_other_settings_unchanged(scenario: Scenario) -> None:
    settings = {"network.loss.probability": 0.9, "network.mansd": 1, "trigger.beta": 0.25}
    new = changed(scenario, settings)
    assert new.network.loss == BernoulliLoss(probability=0.9)
    assert (new.network.mansd, new.decaying.beta) == (1, 0.25)
    back = {"network.loss.probability": 0.5, "network.mansd": 2, "trigger.beta": 0.5}
    assert changed(new, back) == scenario
    moved = changed(scenario, {"controller.setpoint": [3.0, 0.0]})
    assert validate(moved.model_dump(mode="json"), "x") == moved


def test_a_new_loss_model_does_not_inherit_the_old_models_keys(scenario: Scenario) -> None:
    values = {"model": "gilbert_elliott", "mean_loss": 0.5, "mean_burst": 3.0}
    settings = {f"network.loss.{key}": value for key, value in values.items()}
    loss = changed(scenario, settings).network.loss
    assert loss == GilbertElliottLoss(mean_loss=0.5, mean_burst=3.0)


def test_changes_are_refused_with_acknowledgements(content: dict[str, Any]) -> None:
    content["network"]["protocol"] = "ack"
    with pytest.raises(CallerError, match='with "ack", nothing can be changed'):
        changed(resolve(validate(content, "here")), {"network.mansd": 1})


def test_settings_are_recorded_in_full() -> None:
    settings = {"network.loss": {"model": "lossless"}, "trigger.beta": 0.1 + 0.2}
    data = settings_bytes(settings)
    assert len(data) == CHANGE_BYTES
    assert settings_of(data) == settings
    assert not is_of_loss_alone(settings)
    assert is_of_loss_alone({"network.loss.probability": 0.1, "network.loss.model": "x"})
    assert text_of(settings) == 'network.loss = { model = "lossless" }, trigger.beta = 0.3'


def test_changes_announced_out_of_order_are_applied_in_order_of_time(scenario: Scenario) -> None:
    schedule = ChangeSchedule(scenario)
    schedule.announce("t", ParameterChange(0, 200, {"trigger.beta": 0.1}), 0, 0, -1)
    schedule.announce("t", ParameterChange(1, 100, {"network.mansd": 5}), 1, 0, -1)
    assert schedule.next_ns == 100
    assert schedule.take(99) == []
    changes = schedule.take(250)
    assert [change.since_ns for change in changes] == [100, 200]
    scenarios = [change.scenario for change in changes]
    assert [(scenario.network.mansd, scenario.decaying.beta) for scenario in scenarios] == [
        (5, 0.5),
        (5, 0.1),
    ]
    assert schedule.take(10**9) == []
    assert schedule.next_ns > 10**18
    caps = [scenario.network.mansd for scenario in schedule.between(0, 150)]
    assert caps == [2, 5]
