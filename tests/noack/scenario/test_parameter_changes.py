"""Changes of runtime parameters: the keys, their notation, and each machine's schedule."""

from typing import Any

import pytest

from noack.core.errors import CallerError
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
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


@pytest.fixture
def scenario(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "here"))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"speed": 2.0}, "speed: cannot be changed during a run; these can: network.loss, "),
        ({"network.loss.probability": 1.5}, "network.loss.probability = 1.5: should be less than"),
        ({"network.loss.model": "gilbert"}, "must be one of .* did you mean gilbert_elliott"),
        ({"network.loss.model": "trace", "network.loss.file": "x"}, "read before a run begins"),
        ({"trigger.beta": None}, "trigger.beta: needs a value"),
        ({"controller.setpoint": [1.0, 1.0]}, "controller.setpoint.*no equilibrium of the model"),
        ({"network.loss": {"model": "scripted", "lost": list(range(900))}}, "at most 1024"),
    ],
)
def test_an_invalid_change_is_refused_in_one_line(
    scenario: Scenario, settings: dict[str, Any], why: str
) -> None:
    with pytest.raises(CallerError, match=rf"^[^\n]*{why}[^\n]*$"):
        changed(scenario, settings)


def test_a_change_leaves_all_other_settings_unchanged(scenario: Scenario) -> None:
    settings = {"network.loss.probability": 0.9, "network.mansd": 1, "trigger.beta": 0.25}
    found = changed(scenario, settings)
    assert found.network.loss == BernoulliLoss(probability=0.9)
    assert (found.network.mansd, found.decaying.beta) == (1, 0.25)
    back = {"network.loss.probability": 0.5, "network.mansd": 2, "trigger.beta": 0.5}
    assert changed(found, back) == scenario
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
    assert schedule.take(99) is None
    first, second = schedule.take(250), schedule.take(250)
    assert first is not None
    assert second is not None
    assert (first.since_ns, second.since_ns) == (100, 200)
    scenarios = [one.scenario for one in (first, second)]
    assert [(one.network.mansd, one.decaying.beta) for one in scenarios] == [(5, 0.5), (5, 0.1)]
    assert schedule.take(10**9) is None
    assert schedule.next_ns is None
    caps = [one.network.mansd for one in schedule.between(0, 150)]
    assert caps == [2, 5]
