"""A scenario with other values of its runtime parameters."""

import json
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from noack.config.feature_kinds import AnyController, AnyTrigger
from noack.config.runtime_parameters import (
    CONSTRAINTS,
    LOSS,
    MANSD,
    put_settings,
    require_runtime_parameters,
)
from noack.config.scenario_checks import check_kept_loss, check_setpoint, check_trigger
from noack.config.sections.network_section import NetworkSection
from noack.config.validation_messages import brief
from noack.impairments.constraints import require_consistent
from noack.impairments.link_settings import Constraints, Mansd, require_scores
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.trace import TraceLoss

if TYPE_CHECKING:
    from noack.config.scenario import Scenario

_AT_FIRST_USE = ConfigDict(defer_build=True)
_CHANGEABLE: Mapping[str, TypeAdapter[Any]] = {
    LOSS: TypeAdapter(Loss, config=_AT_FIRST_USE),
    MANSD: TypeAdapter(Mansd, config=_AT_FIRST_USE),
    CONSTRAINTS: TypeAdapter(Constraints, config=_AT_FIRST_USE),
    "trigger": TypeAdapter(AnyTrigger, config=_AT_FIRST_USE),
    "controller": TypeAdapter(AnyController, config=_AT_FIRST_USE),
}
"""The parts of a scenario that may change during a run."""


def prepare_changes() -> None:
    """Build the validators of changes, which takes 20 ms, before a loop needs them."""
    for part in _CHANGEABLE.values():
        part.rebuild()


def with_settings(scenario: "Scenario", settings: Mapping[str, Any]) -> "Scenario":
    """Return a scenario with other values of its runtime parameters.

    Only the parts that change are validated: the processes of a run do this in their loop. Raise
    ValueError if a key is not a runtime parameter, or the scenario would be invalid.
    """
    if scenario.protocol.acknowledges:
        raise ValueError('network.protocol: with "ack", nothing can be changed during a run')
    require_runtime_parameters(settings, scenario.trigger)
    sections = {key.split(".")[0] for key in settings} - {"network"}
    changes_loss = any(key.startswith(LOSS) for key in settings)
    loss = scenario.network.loss
    content: dict[str, Any] = {
        name: getattr(scenario, name).model_dump(mode="json", exclude_none=True)
        for name in sections
    }
    content["network"] = {
        "loss": loss.model_dump(mode="json", exclude_none=True) if changes_loss else {}
    }
    put_settings(content, settings)
    update: dict[str, Any] = {name: _validated(name, content[name]) for name in sections}
    update["changes"] = ()
    update["network"] = _changed_network(scenario, content["network"], changes_loss)
    changed = scenario.model_copy(update=update)
    if "trigger" in sections:
        check_trigger(changed)
    if "controller" in sections:
        check_setpoint(changed)
    if "network" in sections or any(key.startswith("network.") for key in settings):
        check_kept_loss(changed)
    return changed


def content_with_settings(scenario: "Scenario", settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario's content with other values of its runtime parameters, unchecked.

    Raise ValueError if a key is not a runtime parameter.
    """
    require_runtime_parameters(settings, scenario.trigger)
    content = scenario.model_dump(mode="json", exclude_none=True, exclude={"changes"})
    put_settings(content, settings)
    return content


def check_changes(scenario: "Scenario") -> None:
    """Raise ValueError if a scheduled change is not possible, or the changes are not in order."""
    for (place, one), (_, other) in pairwise(enumerate(scenario.changes)):
        if other.at_s < one.at_s:
            raise ValueError(f"changes.{place + 1}.at_s: earlier than the change before it")
    changed = scenario
    for place, change in enumerate(scenario.changes):
        if change.at_ns >= scenario.timing.horizon_ns:
            raise ValueError(f"changes.{place}.at_s: the run ends at {scenario.horizon_s:g} s")
        try:
            changed = with_settings(changed, change.set)
        except ValidationError as error:
            raise ValueError(f"changes.{place}.set: {brief(error)}") from None
        except ValueError as error:
            raise ValueError(f"changes.{place}.set: {error}") from None


def _changed_network(
    scenario: "Scenario", content: Mapping[str, Any], changes_loss: bool
) -> NetworkSection:
    """Return the network with another cap or loss model; its other settings cannot change."""
    update: dict[str, Any] = {}
    if "mansd" in content:
        update["mansd"] = _validated(MANSD, content["mansd"])
    if "constraints" in content:
        update["constraints"] = _validated(CONSTRAINTS, content["constraints"])
        require_consistent(scenario.network.mansd, update["constraints"])
    if changes_loss:
        update["loss"] = _validated(LOSS, content["loss"])
        if isinstance(update["loss"], TraceLoss):
            raise ValueError(
                "network.loss.model: a trace is read before a run begins; give its losses as "
                '{ model = "scripted", lost = [...] }'
            )
        require_scores(scenario.network.impairments, update["loss"])
    return scenario.network.model_copy(update=update)


def _validated(part: str, content: Any) -> Any:
    return _CHANGEABLE[part].validate_json(json.dumps(content))
