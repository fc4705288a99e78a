"""The settings of a scenario that are worth dragging: sliders and choices, with their ranges."""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from pydantic import BaseModel

from cosim.interactive.scenario_draft import Draft, DraftError
from noack.core.clock import NS_PER_S
from noack.scenario.runtime_parameters import trigger_parameters
from noack.scenario.scenario import Scenario
from noack.scenario.sections import POLICIES
from noack.settings.section import Table

_STEPS = 200
"""Steps of a logarithmic slider."""
_DECADE = 10.0
"""Factor from the middle of a slider to its ends."""
_MOST_LOSSES, _MOST_WINDOW = 20, 40
"""Ends of the sliders for consecutive losses, and for the window of a constraint."""
_BELOW = 0.99
"""The largest share of a limit that must not be reached."""
_SEEDS = 200
"""Largest seed of a slider."""
_MOST_MODEL_ERROR = 20.0
"""Largest multiple of the uncertainty."""
_NUMBERS = ("number", "integer")
_LOSSES: Mapping[str, Mapping[str, object]] = {
    "bernoulli": {"probability": 0.5},
    "gilbert_elliott": {"mean_loss": 0.5, "mean_burst": 3.0},
    "worst_case": {},
    "lossless": {},
}
"""The loss models that are offered, with their first settings."""
_LOSS_NAMES = {
    "bernoulli": "Bernoulli (independent)",
    "gilbert_elliott": "Gilbert–Elliott (bursts)",
    "worst_case": "worst case",
    "lossless": "no losses",
}
_WINDOW: Mapping[str, object] = {"kind": "at_most", "losses": 5, "window": 10}


@dataclass(frozen=True)
class Slider:
    """A number that can be dragged."""

    key: str
    label: str
    value: float
    low: float
    high: float
    step: float
    """Step of the value; of its decimal logarithm if ``logarithmic``."""
    whole: bool = False
    multiple_of: float = 0.0
    """The value is a multiple of this; 0: any value."""
    logarithmic: bool = False
    live: bool = False
    """Whether a running loop can change it."""
    scaled: tuple[str, ...] = ()
    """Matrices that the value multiplies, by key; ``key`` itself is then not in the scenario."""

    @property
    def position(self) -> float:
        """The position of the value on the slider."""
        return self.position_of(self.value)

    @property
    def ends(self) -> tuple[float, float]:
        """The positions of both ends."""
        return self.position_of(self.low), self.position_of(self.high)

    def position_of(self, value: float) -> float:
        """Return the position of a value on the slider."""
        value = min(max(value, self.low), self.high)
        return math.log10(value) if self.logarithmic else value

    def value_at(self, position: float) -> float | int:
        """Return the value at a position: whole, a multiple, or with three significant digits."""
        value = 10.0**position if self.logarithmic else position
        value = min(max(value, self.low), self.high)
        if self.multiple_of:
            return float(f"{max(round(value / self.multiple_of), 1) * self.multiple_of:.9g}")
        return round(value) if self.whole else float(f"{value:.3g}")


@dataclass(frozen=True)
class Choice:
    """A setting with a few values."""

    key: str
    label: str
    value: str
    options: Mapping[str, str]
    """By value: its text."""


@dataclass(frozen=True)
class Controls:
    """What can be dragged and chosen for a scenario."""

    choices: tuple[Choice, ...]
    sliders: tuple[Slider, ...]

    @property
    def shape(self) -> tuple[object, ...]:
        """What decides which elements are shown; with equal shapes only values differ."""
        return (
            *((choice.key, choice.value, *choice.options) for choice in self.choices),
            *((slider.key, *slider.ends) for slider in self.sliders),
        )


_TRIGGER_LABELS = {
    "alpha_per_s": "α, decay of the threshold [1/s]",
    "beta": "β, threshold at the start",
    "floor": "ε, smallest threshold",
    "period_s": "period [s]",
}


def controls_of(draft: Draft) -> Controls:
    """Return the controls of a draft; ranges depend on the base, so that dragging keeps them.

    Raises:
        DraftError: the draft is not valid.
    """
    scenario = draft.scenario
    base = _base_scenario(draft)
    sliders = (
        *_loss_sliders(scenario, base),
        *_guarantee_sliders(scenario),
        *_trigger_sliders(scenario, base),
        *_plant_sliders(scenario, base),
        _seed("seeds.loss", "random seed of the losses", scenario.seeds.loss),
        _seed("seeds.plant", "random seed of the plant", scenario.seeds.plant),
        _decades("horizon_s", "horizon [s]", scenario.horizon_s, base.horizon_s, live=False),
    )
    return Controls(_choices(scenario), sliders)


def _choices(scenario: Scenario) -> tuple[Choice, ...]:
    modes = {"model": "model-based", "zoh": "zero-order hold"}
    policies = {name: name.replace("_", " ") for name in POLICIES if name != "python"}
    policy, loss = scenario.trigger.policy, scenario.network.loss.model
    constraints = scenario.network.constraints
    kind = ""
    if constraints:
        kind = str(_WINDOW["kind"]) if _is_window(scenario) else "own"
    limits = {"": "M − 1 consecutive", str(_WINDOW["kind"]): "also m in any K packets"}
    return (
        Choice("mode", "mode: input between updates", scenario.mode, modes),
        Choice("trigger", "trigger policy: when the sensor transmits", policy,
               {policy: policy.replace("_", " ")} | policies),
        Choice("network.loss", "loss model", loss, {loss: loss.replace("_", " ")} | _LOSS_NAMES),
        Choice("network.constraints", "guarantee: most losses", kind,
               limits | ({"own": "as given"} if kind == "own" else {})),
    )  # fmt: skip


def _is_window(scenario: Scenario) -> bool:
    """Whether the only further constraint is at most m losses in any K packets."""
    return [constraint.kind for constraint in scenario.network.constraints] == [_WINDOW["kind"]]


def choose(draft: Draft, key: str, value: str) -> Draft:
    """Return the draft with another choice; tables take the example of their kind."""
    if (example := example_of(draft, key, value)) is not None:
        return draft.with_value(key, example)
    if key == "network.constraints":
        return draft.with_value(key, [_WINDOW] if value == _WINDOW["kind"] else [])
    return draft.with_value(key, value)


def drag(draft: Draft, slider: Slider, value: float) -> Draft:
    """Return the draft with another value of a slider."""
    if not slider.scaled:
        return draft.with_value(slider.key, value)
    base = _base_of(draft)
    for key in slider.scaled:
        matrix = np.array(base.value(key), dtype=np.float64)
        draft = draft.with_value(
            key, [[float(f"{value * entry:.6g}") for entry in row] for row in matrix.tolist()]
        )
    return draft


def _base_of(draft: Draft) -> Draft:
    return Draft(draft.base, draft.folder, draft.base_text, draft.base_text)


def _base_scenario(draft: Draft) -> Scenario:
    """Return the base's scenario with the draft's trigger policy and loss model, if these fit it."""
    base, scenario = _base_of(draft), draft.scenario
    usual = base.scenario
    if usual.trigger.policy != scenario.trigger.policy:
        base = choose(base, "trigger", scenario.trigger.policy)
    if usual.network.loss.model != scenario.network.loss.model:
        base = choose(base, "network.loss", scenario.network.loss.model)
    with suppress(DraftError):
        usual = base.scenario
    return usual


def example_of(draft: Draft, key: str, kind: str) -> Table | None:
    """Return an example of a table of a kind; None if there is none.

    Raises:
        DraftError: the draft is not valid, and the example depends on the number of states.
    """
    if key == "network.loss" and kind in _LOSSES:
        return {"model": kind, **_LOSSES[kind]}
    if key == "trigger" and kind in POLICIES:
        example = POLICIES[kind].example(draft.scenario.model.dimensions[0])
        return None if example is None else example.content()
    return None


def _loss_sliders(scenario: Scenario, base: Scenario) -> list[Slider]:
    loss, usual = scenario.network.loss, base.network.loss
    values = loss.model_dump(mode="json", exclude_none=True)
    # The mean loss and burst are those of Gilbert's chain, which loses in the bad state only.
    fixed_names = ("loss_in_good", "loss_in_bad") if "mean_loss" in values else ()
    sliders = []
    for name, value in values.items():
        key, label = f"network.loss.{name}", f"loss: {_words(name)}"
        if name in fixed_names or not isinstance(value, float):
            continue
        if 0 <= value <= 1 and "[" not in label:  # it has no unit
            label = "loss probability" if name == "probability" else label
            slider = Slider(key, label, value, 0.0, 1.0, 0.01, live=True)
        elif value > 0:
            usual_value = getattr(usual, name, None) if usual.model == loss.model else None
            slider = _decades(key, label, value, usual_value or value)
        else:
            continue
        sliders.append(_within_field(slider, type(loss), name))
    return sliders


def _guarantee_sliders(scenario: Scenario) -> list[Slider]:
    mansd = Slider(
        "network.mansd",
        "maximum consecutive losses (M − 1)",
        scenario.network.mansd,
        0,
        max(_MOST_LOSSES, scenario.network.mansd),
        1,
        whole=True,
        live=True,
    )
    if not _is_window(scenario):
        return [mansd]
    window = scenario.network.constraints[0].model_dump()
    losses, packets = window["losses"], window["window"]
    return [
        mansd,
        Slider("network.constraints.0.losses", f"m: losses in any {packets} packets", losses, 0,
               packets - 1, 1, whole=True),
        Slider("network.constraints.0.window", f"K: packets with at most {losses} losses",
               packets, losses + 1, max(_MOST_WINDOW, packets), 1, whole=True),
    ]  # fmt: skip


def _trigger_sliders(scenario: Scenario, base: Scenario) -> list[Slider]:
    trigger, usual = scenario.trigger, base.trigger
    sliders = []
    for key in trigger_parameters(trigger):
        name = key.removeprefix("trigger.")
        value = getattr(trigger, name)
        usual_value = getattr(usual, name, None) if usual.policy == trigger.policy else None
        if isinstance(value, int | float) and value > 0:
            label = _TRIGGER_LABELS.get(name, f"trigger: {_words(name)}")
            slider = _decades(key, label, value, usual_value or value)
            if name == "period_s":
                period_s = scenario.timing.measurement_period_ns / NS_PER_S
                slider = replace(slider, multiple_of=period_s)
            sliders.append(_within_field(slider, type(trigger), name))
    return sliders


def _within_field(slider: Slider, section: type[BaseModel], name: str) -> Slider:
    """Return the slider with values only that its key can have."""
    least, most = _limits(section, name)
    low, high = max(slider.low, least), min(slider.high, most)
    return replace(slider, low=min(low, slider.value), high=max(high, slider.value))


@cache
def _limits(section: type[BaseModel], name: str) -> tuple[float, float]:
    """Return the least and the largest number that a key can have, from the JSON schema."""
    schema = section.model_json_schema()
    properties = schema.get("$defs", {}).get(section.__name__, schema)["properties"]
    kinds = properties[name].get("anyOf", [properties[name]])
    number: Mapping[str, float] = next((kind for kind in kinds if kind.get("type") in _NUMBERS), {})
    below = _BELOW * number.get("exclusiveMaximum", math.inf)
    return number.get("minimum", -math.inf), min(number.get("maximum", math.inf), below)


def _plant_sliders(scenario: Scenario, base: Scenario) -> list[Slider]:
    """Return the slider of the box around the model from which the plant is drawn."""
    if scenario.plant.draw not in ("uniform", "vertex"):
        return []
    factors = {}
    for name in ("uncertainty_A", "uncertainty_B"):
        usual = np.array(getattr(base.plant, name) or [[]], dtype=np.float64)
        now = np.array(getattr(scenario.plant, name) or [[]], dtype=np.float64)
        if usual.any() and usual.shape == now.shape:
            largest = np.unravel_index(np.argmax(np.abs(usual)), usual.shape)
            factors[f"plant.{name}"] = float(now[largest] / usual[largest])
    if not factors:
        return []
    value = max(factors.values())
    return [
        Slider(
            "plant.uncertainty",
            "model error, as a multiple of the scenario's uncertainty",
            round(value, 3),
            0.0,
            max(_MOST_MODEL_ERROR, value),
            0.1,
            scaled=tuple(factors),
        ),
    ]


def _decades(key: str, label: str, value: float, middle: float, *, live: bool = True) -> Slider:
    """Return a slider over two decades around a value; whole numbers for an integer."""
    whole = isinstance(value, int)
    low, high = max(middle / _DECADE, 1.0 if whole else 0.0), middle * _DECADE
    step = math.log10(high / low) / _STEPS
    return Slider(
        key, label, value, min(low, value), max(high, value), step, whole=whole, logarithmic=True, live=live
    )


def _words(name: str) -> str:
    for unit in ("per_s", "s", "hz"):
        if name.endswith(f"_{unit}"):
            text = unit.replace("per_s", "1/s").replace("hz", "Hz")
            return f"{name.removesuffix(f'_{unit}').replace('_', ' ')} [{text}]"
    return name.replace("_", " ")


def _seed(key: str, label: str, seed: int) -> Slider:
    return Slider(key, label, min(seed, _SEEDS), 0, _SEEDS, 1, whole=True)
