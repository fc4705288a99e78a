"""The scenario of a loop that is tried."""

import math
import os

import numpy as np

from cosim.studies.new_loop import BETA_SHARE, DEFAULT_LOSS_PROBABILITY, HORIZON_DECAY
from cosim.studies.new_loop.choices import Choices
from cosim.studies.new_loop.trials import LoopTrial
from netem.core.number_format import to_digits
from netem.core.settings_section import Table
from noack.core.linear_systems import Matrix, norm
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed, put

POLICY = "decaying"
"""The rule whose threshold is chosen."""
SMALL_FLOOR_SHARE, LARGEST_FLOOR_SHARE = 0.05, 0.5
"""The last threshold as a share of beta: without allowed errors, and at most for them."""


def scenario_of(choices: Choices, trial: LoopTrial) -> Scenario:
    """Return the loaded scenario of a trial."""
    return completed(content_of(choices, trial), choices.path)


def content_of(choices: Choices, trial: LoopTrial) -> Table:
    """Return the content of a trial's scenario file."""
    model, plant = choices.model, choices.model.plant
    start = trial.x0 if trial.weight is None else trial.weight @ trial.x0
    beta = to_digits(BETA_SHARE * norm(start) or BETA_SHARE)
    horizon_s, speed = _horizon_and_speed(trial)
    has_own_units = any(plant.units) and not plant.system.states  # a kind of plant gives its units
    content: Table = {
        "name": "".join(c if c.isascii() and c.isalnum() else "_" for c in choices.path.stem),
        "description": _description(choices),
        "horizon_s": horizon_s,
        "speed": speed,
        "model": {
            "A": model.A.tolist(),
            "B": model.B.tolist(),
            "gain": trial.gain.K.tolist(),
            **({"integral": [*trial.gain.integrals]} if trial.gain.integrals else {}),
            "state_names": list(plant.state_names),
            **({"state_units": list(plant.units)} if has_own_units else {}),
            "input_names": list(plant.input_names),
        },
        "plant": {
            "initial_state": trial.x0.tolist(),
            "rate_hz": trial.rate_hz,
            "measure_every": int(plant.rates.get("measure_every", 1)),
            "system": _system(choices),
        },
        "controller": {"rate_hz": trial.rate_hz},
        "trigger": {
            "policy": POLICY,
            "beta": beta,
            "alpha_per_s": trial.alpha_per_s,
            "floor": _first_floor(choices, trial, beta) if trial.floor is None else trial.floor,
            **({} if trial.weight is None else {"weight": _rows(trial.weight)}),
        },
        "network": {
            "mansd": trial.mansd,
            "loss": {"model": "bernoulli", "probability": DEFAULT_LOSS_PROBABILITY},
        },
        "seeds": {"loss": 1},
        **({"outputs": outputs} if (outputs := _outputs(choices)) else {}),
    }
    for key, value in choices.fixed_settings.items():
        put(content, key, value, f"--set {key}")
    return content


def _horizon_and_speed(trial: LoopTrial) -> tuple[float, float]:
    """Return how long a run lasts, in s, and the simulated time per wall time of a live run.

    At the end the threshold has decayed, and the guarantee has held for a while. A run of less than 4.6 s
    would show little; a live run takes some 20 s. A scenario has at most 1e7 s, and a speed of 1000.
    """
    decayed_s = math.log(1 / HORIZON_DECAY) / trial.alpha_per_s
    horizon_s = min(to_digits(max(decayed_s, 1.2 * trial.guaranteed_from_s, 4.6)), 1e7)
    return horizon_s, min(max(1.0, float(round(horizon_s / 20.0))), 1000.0)


def _description(choices: Choices) -> str:
    """Return what the scenario is, in a sentence."""
    has_own_network = any(key.startswith("network") for key in choices.fixed_settings)
    losses = "" if has_own_network else " that loses half of the updates"
    return f"{choices.model.plant.label} over a network{losses}."


def _rows(weight: Matrix) -> list[list[float]]:
    """Return the rows of W, with the digits of a file."""
    return [[to_digits(entry, 6) for entry in row] for row in weight]


def _first_floor(choices: Choices, trial: LoopTrial, beta: float) -> float:
    """Return the last threshold that is tried first.

    With friction it is a share of the first allowed error.
    """
    floor = SMALL_FLOOR_SHARE * beta
    if choices.allowed and trial.has_friction:
        floor = min(0.15 * next(iter(choices.allowed.values())), beta / 2)
    elif choices.allowed and not choices.is_linear:
        floor = LARGEST_FLOOR_SHARE * beta
    return to_digits(floor, 3)


def _outputs(choices: Choices) -> list[Table]:
    """Return the outputs: the states with an allowed error, else the first four whose units are known."""
    plant = choices.model.plant
    units = dict(zip(plant.state_names, plant.units, strict=False))
    names = [*choices.allowed] or [name for name, unit in units.items() if unit][:4]
    outputs = list[Table]()
    for name in names:
        keys = {"unit": units.get(name, ""), "allowed": choices.allowed.get(name)}
        outputs.append({"name": name, **{key: value for key, value in keys.items() if value}})
    return outputs


def _system(choices: Choices) -> Table:
    """Return the table plant.system, with a file's name relative to the scenario's folder."""
    model = choices.model
    system = model.plant.system
    table = system.content()
    if isinstance(file := table.get("file"), str):
        table["file"] = os.path.relpath(file, choices.path.absolute().parent)
        table.pop("sha256", None)
    if system.has_operating_point:
        for key, value in (("operating_state", model.at), ("operating_input", model.input)):
            if value.any():
                table[key] = (value + np.array(getattr(system, key) or 0.0)).tolist()
    return {key: value for key, value in table.items() if value not in ({}, [])}
