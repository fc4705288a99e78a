"""The settings of a scenario that are worth dragging: sliders and choices, with their ranges."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import noack
from noack_lab.scenario_draft import Draft

_STEPS = 200
"""Steps of a logarithmic slider."""
_DECADE = 10.0
"""Factor from the middle of a slider to its ends."""
_MOST_LOSSES, _MOST_SEED, _MOST_MODEL_ERROR = 20, 200, 20.0
"""Ends of the sliders for consecutive losses, for seeds, and for the multiple of the uncertainty."""
MODEL_ERROR = "plant.uncertainty"
"""Stands for both matrices of the uncertainty, which the slider multiplies."""
_MATRICES = ("plant.uncertainty_A", "plant.uncertainty_B")

MODES = {"model": "model-based", "zoh": "zero-order hold"}
LOSSES: Mapping[str, Mapping[str, object]] = {
    "bernoulli": {"probability": 0.5},
    "gilbert_elliott": {"mean_loss": 0.5, "mean_burst": 3.0},
    "worst_case": {},
    "lossless": {},
}
"""The loss models that are offered, with their first settings."""
POLICIES: Mapping[str, Mapping[str, object]] = {
    "decaying": {"beta": 0.5, "alpha_per_s": 0.25},
    "absolute": {"delta": 0.05},
    "relative": {"sigma": 0.2},
    "mixed": {"sigma": 0.1, "epsilon": 0.05},
    "dynamic": {"sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5, "eta_0": 1.0},
    "lyapunov": {"rate_per_s": 0.3},
    "send_on_area": {"delta_s": 0.02},
    "periodic": {"period_s": 1.0},
}
"""The trigger policies that are offered, with their first settings."""
_LABELS = {
    "network.loss.probability": "loss probability",
    "network.mansd": "lost in a row, at most",
    "trigger.alpha_per_s": "α, decay of the threshold [1/s]",
    "trigger.beta": "β, threshold at the start",
    "trigger.floor": "ε, smallest threshold",
    "trigger.period_s": "period [s]",
    MODEL_ERROR: "model error, as a multiple of the scenario's uncertainty",
    "seeds.loss": "random seed of the losses",
    "seeds.plant": "random seed of the plant",
    "horizon_s": "horizon [s]",
}
_PERIOD_STEP_S = 0.001


@dataclass(frozen=True)
class Slider:
    """A number that can be dragged."""

    key: str
    value: float
    low: float
    high: float
    step: float
    """Step of the value; of its decimal logarithm if ``logarithmic``."""
    logarithmic: bool = False
    multiple_of: float = 0.0
    """The value is a multiple of this; 0: any value."""

    @property
    def label(self) -> str:
        """Its name on the page."""
        return _LABELS.get(self.key, self.key.replace(".", ": ").replace("_", " "))

    @property
    def text(self) -> str:
        """The value as text."""
        return f"{self.value:.4g}"

    @property
    def is_live(self) -> bool:
        """Whether a running loop can change it."""
        return self.key == "network.mansd" or self.key.startswith(("network.loss.", "trigger."))

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
        return round(value) if isinstance(self.value, int) else float(f"{value:.3g}")


def sliders(draft: Draft, base: Draft) -> list[Slider]:
    """Return the sliders of a draft; their ranges are around the values of the draft that it began as.

    Raises:
        NoackError: the draft is not valid.
    """
    scenario, usual = draft.scenario, base.scenario
    network, seeds = scenario.network, scenario.seeds
    return [
        *_loss_sliders(scenario, usual),
        Slider("network.mansd", network.mansd, 0, max(_MOST_LOSSES, network.mansd), 1),
        *_trigger_sliders(scenario, usual),
        *_model_error(draft, base),
        Slider("seeds.loss", min(seeds.loss, _MOST_SEED), 0, _MOST_SEED, 1),
        Slider("seeds.plant", min(seeds.plant, _MOST_SEED), 0, _MOST_SEED, 1),
        _decades("horizon_s", scenario.horizon_s, usual.horizon_s),
    ]


def choose(draft: Draft, key: str, value: str) -> Draft:
    """Return the draft with another mode, loss model or trigger policy, with its first settings."""
    match key:
        case "network.loss":
            return draft.with_value(key, {"model": value, **LOSSES[value]})
        case "trigger":
            return draft.with_value(key, {"policy": value, **POLICIES[value]})
    return draft.with_value(key, value)


def drag(draft: Draft, base: Draft, key: str, value: float) -> Draft:
    """Return the draft with another value of a slider."""
    if key != MODEL_ERROR:
        return draft.with_value(key, value)
    for matrix in _MATRICES:
        if (rows := base.value(matrix)) is not None:
            scaled = [[float(f"{value * entry:.6g}") for entry in row] for row in rows]
            draft = draft.with_value(matrix, scaled)
    return draft


def _loss_sliders(scenario: noack.Scenario, usual: noack.Scenario) -> list[Slider]:
    loss: Any = scenario.network.loss  # of one of many models
    before = usual.network.loss
    if loss.model == "bernoulli":
        return [Slider("network.loss.probability", loss.probability, 0.0, 1.0, 0.01)]
    if loss.model == "gilbert_elliott" and loss.mean_loss is not None and loss.mean_burst is not None:
        burst = getattr(before, "mean_burst", None) or loss.mean_burst
        bursts = _decades("network.loss.mean_burst", loss.mean_burst, burst)
        return [
            Slider("network.loss.mean_loss", loss.mean_loss, 0.0, 0.99, 0.01),
            replace(bursts, low=max(1.0, bursts.low)),
        ]
    return []


def _trigger_sliders(scenario: noack.Scenario, usual: noack.Scenario) -> list[Slider]:
    """Return a slider for each positive number of the trigger, over two decades."""
    found = []
    before = usual.trigger.model_dump() if usual.trigger.policy == scenario.trigger.policy else {}
    for name, value in scenario.trigger.model_dump().items():
        if isinstance(value, float) and value > 0:
            slider = _decades(f"trigger.{name}", value, before.get(name) or value)
            if name == "sigma":  # of a threshold σ‖x‖
                slider = replace(slider, high=max(value, min(slider.high, 0.99)))
            if name == "period_s":
                period_s = scenario.timing.measurement_period_ns * 1e-9 or _PERIOD_STEP_S
                slider = replace(slider, multiple_of=period_s)
            found.append(slider)
    return found


def _model_error(draft: Draft, base: Draft) -> list[Slider]:
    """Return the slider of the plant's uncertainty, from which the plant is drawn."""
    if draft.scenario.plant.draw not in ("uniform", "vertex"):
        return []
    factors = [_ratio(draft.value(key), base.value(key)) for key in _MATRICES]
    value = round(max(factors), 3)
    if not any(base.value(key) for key in _MATRICES):
        return []
    return [Slider(MODEL_ERROR, value, 0.0, max(_MOST_MODEL_ERROR, value), 0.1)]


def _ratio(matrix: Any, usual: Any) -> float:
    """Return the factor between two matrices of the same form; 0 without one."""
    entries = [abs(entry) for row in matrix or () for entry in row]
    usual_entries = [abs(entry) for row in usual or () for entry in row]
    return max(entries, default=0.0) / (max(usual_entries, default=0.0) or 1.0)


def _decades(key: str, value: float, middle: float) -> Slider:
    """Return a slider over two decades around a value."""
    low, high = min(middle / _DECADE, value), max(middle * _DECADE, value)
    return Slider(key, value, low, high, math.log10(high / low) / _STEPS, logarithmic=True)
