"""Scenarios from a file, a table or the user's own matrices, and with other settings."""

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TypeGuard

import numpy as np

from cosim.shipped_files import find_shipped, shipped_names, text_of
from cosim.studies.new_loop import (
    ALPHA_SHARE,
    BETA_SHARE,
    DEFAULT_LOSS_PROBABILITY,
    DEFAULT_MANSD,
    HORIZON_DECAY,
)
from netem.core.number_format import to_digits
from netem.core.settings_section import ReadTable, Table
from noack.core.linear_systems import spectral_abscissa
from noack.scenario.given_settings import given_settings, plain, plain_table
from noack.scenario.matrix_files import controller_of, matrices_of, model_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed_with, load_with, network_of

Source = Scenario | str | PathLike[str] | ReadTable
"""A scenario; or the name of a shipped one, a file, or a table with a scenario file's content."""
_NAMED = "settings: "
"""What stands before a key in a message about a setting."""


def load(
    source: Source, settings: ReadTable | None = None, *, network: str | PathLike[str] | None = None
) -> Scenario:
    """Load a scenario.

    >>> import noack
    >>> scenario = noack.load("lane_following", {"network.mansd": 2})
    >>> scenario.network.mansd, scenario.trigger.beta
    (2, 0.5)

    Args:
        source: the name of a shipped scenario (``"lane_following"``); or the path of a scenario
            file or of a run directory; or its content as a table, ``{"name": ..., "model": {...},
            ...}``. Relative file names in a table are relative to the working directory. A scenario
            is returned as it is.
        settings: values that replace the source's, as in :func:`with_settings`.
        network: a file whose table ``[network]`` replaces the source's, before the settings: e.g. one
            that :meth:`Measurement.write_network` wrote.

    Raises:
        NoackError: one line per mistake, each with key, value and remedy.
    """
    given, table = given_settings(settings), None if network is None else network_of(Path(network))
    if isinstance(source, Scenario):
        if table is not None:
            source = load(source.model_dump(mode="json", exclude_none=True) | {"network": table})
        return with_settings(source, settings) if settings else source
    if isinstance(source, Mapping):
        content = plain_table(source) | ({} if table is None else {"network": table})
        return completed_with(content, given, Path("scenario"), _NAMED)
    path = None if network is None else Path(network)
    return load_with(find_shipped(str(source), "scenarios"), given, _NAMED, network=path)


def scenarios() -> dict[str, str]:
    """Return the texts of the scenarios that come with noack, by name, to be copied and edited.

    >>> import noack
    >>> 'name = "lane_following"' in noack.scenarios()["lane_following"]
    True
    """
    return {name: text_of(name) for name in shipped_names("scenarios")}


def with_settings(scenario: Scenario, settings: ReadTable) -> Scenario:
    """Return the scenario with other settings; the given scenario is not changed.

    >>> import noack
    >>> scenario = noack.load("lane_following")
    >>> noack.with_settings(scenario, {"trigger.beta": 0.3}).trigger.beta
    0.3

    Args:
        scenario: as loaded, or of a run.
        settings: values by the keys of a scenario file, with dots between their parts:
            ``{"network.loss.probability": 0.8, "trigger.beta": 0.3}``, or by the short names of the
            runtime parameters, ``loss.p``. NumPy arrays are accepted. None restores the default of
            a key. ``docs/scenarios.md`` documents the keys and their units.

    Raises:
        NoackError: one line per mistake, each with key, value and remedy.
    """
    content = scenario.model_dump(mode="json", exclude_none=True)
    return completed_with(content, given_settings(settings), Path(scenario.name), _NAMED)


def from_system(
    system: object,
    gain: object,
    initial_state: Sequence[float],
    *,
    plant: object = None,
    controller: object = None,
    settings: ReadTable | None = None,
    name: str = "own_system",
    state_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
) -> Scenario:
    """Return a scenario for the user's own linear model, with n states and m inputs.

    Without ``settings``, these values are chosen: the trigger's α is half the decay rate of Â +
    B̂K; its β is a tenth of ‖x(0)‖ (0.1 if x(0) = 0); the horizon is the time in which e^(−αt)
    falls to a hundredth. Each has three digits. At most 4 updates are lost in a row, and half of all.

    >>> import noack
    >>> A, B = [[0.0, 1.0], [2.0, -0.5]], [[0.0], [1.0]]
    >>> scenario = noack.from_system((A, B), gain=[[-6.0, -4.0]], initial_state=[1.0, 0.0])
    >>> scenario.trigger.alpha_per_s, scenario.trigger.beta, scenario.horizon_s
    (0.61, 0.1, 7.55)

    Args:
        system: the model ẋ = Âx + B̂u as a tuple (A, B) of matrices (n, n), per second, and (n, m);
            or ``control.StateSpace`` or ``scipy.signal.StateSpace``, whose output is the state; one in
            discrete time, as ``control.c2d`` returns it, is taken back to continuous time.
        gain: K of u = Kx, (m, n), which must stabilise the model; or what ``control.lqr``,
            ``control.dlqr`` or ``scipy.signal.place_poles`` returned, whose K is that of u = −Kx.
        initial_state: x(0), n entries.
        plant: the true plant, as ``system``; by default it is the model, and x_s equals x.
        controller: a linear controller with states of its own, dξ/dt = Aξ + Bx, u = Cξ + Dx: a tuple (A,
            B, C) or (A, B, C, D), or an object as for ``system``. By default u = Kx.
        settings: as in :func:`with_settings`.
        name: of the scenario: letters, digits, _ and -.
        state_names: n names, for plots; by default the names in ``system``, or x_1, x_2, ….
        input_names: m names, likewise.

    Raises:
        NoackError: shapes do not fit; the model is not stable with u = Kx; or settings are wrong.
    """
    model = model_of(system, gain, state_names=state_names, input_names=input_names)
    A, B = model.matrices
    decay_per_s = -spectral_abscissa(A + B @ np.array(model.gain))
    alpha_per_s = to_digits(ALPHA_SHARE * decay_per_s)
    start = plain(initial_state)
    # If it is no vector, the validation reports the mistake.
    norm = float(np.linalg.norm(start)) if _is_vector(start) else 0.0
    true_plant: Table = {"initial_state": start}
    if plant is not None:
        true = matrices_of(plant)
        true_plant |= {"draw": "given", "A": true["A"].tolist(), "B": true["B"].tolist()}
    content: Table = {
        "name": name,
        "horizon_s": to_digits(math.log(1 / HORIZON_DECAY) / alpha_per_s),
        "model": model.model_dump(mode="json", exclude_none=True),
        "plant": true_plant,
        "trigger": {
            "policy": "decaying",
            "beta": to_digits(BETA_SHARE * norm or BETA_SHARE),
            "alpha_per_s": alpha_per_s,
        },
        "network": {
            "mansd": DEFAULT_MANSD,
            "loss": {"model": "bernoulli", "probability": DEFAULT_LOSS_PROBABILITY},
        },
    }
    if controller is not None:
        content["controller"] = controller_of(controller)
    return completed_with(content, given_settings(settings), Path("from_system"), _NAMED)


def _is_vector(value: object) -> TypeGuard[list[float]]:
    return isinstance(value, list) and all(isinstance(entry, int | float) for entry in value)
