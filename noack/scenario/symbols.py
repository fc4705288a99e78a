"""What messages about a scenario's keys say besides: of the paper's symbols, and of extensions."""

from collections.abc import Mapping
from typing import ClassVar

from netem.core.settings_section import ScenarioSection

SYMBOLS = {
    "M": "M is network.mansd + 1; set network.mansd",
    "K": "K is model.gain",
    "α": "α is trigger.alpha_per_s",
    "β": "β is trigger.beta",
    "h": "the sampling period is plant.measure_every / plant.rate_hz",
    "delay": "a delay is an entry of network.impairments",
    "x0": "x(0) is plant.initial_state",
    "seed": "each random part has a seed, e.g. seeds.loss",
}
"""What is said of unknown keys that people write, such as the paper's symbols."""


class ScenarioRoot(ScenarioSection):
    """A table whose mistakes are explained as those of a scenario."""

    key_hints: ClassVar[Mapping[str, str]] = SYMBOLS
    extension_groups: ClassVar[Mapping[str, str]] = {
        "system": "noack.plants",
        "controller": "noack.controllers",
    }
