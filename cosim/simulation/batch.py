"""Many exact runs at once: settings, populations and rows of results.

Everything is in SI units and in the paper's notation; k runs, n states, m inputs.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous import MAX_EVENTS, timeless, vanished, vanishes_s
from cosim.simulation.exact_simulation import ROW as ROW
from cosim.simulation.exact_simulation import EventLog, ExactSimulation
from netem.channel import UPDATE_LINK
from netem.link_state import LinkState, stream_names
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.core.random_streams import stream_keys
from noack.impairments.link_settings import LinkSettings
from noack.scenario.resolution import loop_of, rule_of
from noack.scenario.scenario import Scenario
from noack.trigger.trigger_rule import TriggerRule


class Population(NamedTuple):
    """The data that differ between the runs."""

    A: NDArray[np.float64]
    """True plants, (k, n, n), per second."""
    B: NDArray[np.float64]
    """True plants, (k, n, m)."""
    x0: NDArray[np.float64]
    """x(0), (k, n)."""
    loss_seeds: NDArray[np.uint64]
    """Seeds of the network's losses, (k,)."""


@dataclass(frozen=True)
class Setting:
    """The settings that all runs of a batch share."""

    H: Matrix
    """Matrix of both models between updates: Â + B̂K, or 0 in zero-order-hold mode, (n, n)."""
    K: Matrix
    """Gain, (m, n)."""
    trigger: TriggerRule
    link: LinkSettings
    """Losses, corruption and the cap, as in ``network_fates``."""
    horizon_s: float
    known_start: bool
    """Sensor and controller start from x(0). Otherwise x_c = 0 and event 0 happens at t = 0."""
    Q: Matrix | None = None
    """Symmetric, (n, n); None: the identity."""
    R: Matrix | None = None
    """Symmetric, (m, m); None: the identity."""
    settle: float = 0.02
    """A run has settled when ‖x‖ stays at or below ``settle`` ‖x(0)‖."""
    most_events: int = MAX_EVENTS


class Events(NamedTuple):
    """The events of a run."""

    event_s: Vector
    """(k,)"""
    delivered: NDArray[np.bool_]
    """(k,)"""
    states: NDArray[np.float64]
    """(x, e_s, e_c) just before the events, (k, 3, n)."""


def setting_of(resolved: Scenario) -> Setting:
    """Return the shared settings of a resolved scenario, without its plant, x(0) and seeds.

    Raises:
        CallerError: exact simulation does not support the scenario.
    """
    resolved.coverage.require_unchanging()
    resolved.coverage.require_exact()
    loop = loop_of(resolved)
    return Setting(
        H=loop.H,
        K=loop.K,
        trigger=rule_of(resolved),
        link=timeless(resolved.network.link),
        horizon_s=resolved.horizon_s,
        known_start=resolved.network.initial_sync == "known_state",
    )


def run_batch(setting: Setting, population: Population) -> NDArray[np.void]:
    """Run every draw; a run's row depends bit-exactly on the setting and its own draw only.

    Returns:
        Rows of :data:`ROW`, (k,).

    Raises:
        CallerError: the threshold becomes too small before the horizon, or the link has impairments
            other than losses.
        ValueError: the shapes of the matrices do not match.
    """
    rows, _ = _run(setting, population, 0)
    return rows


def run_events(setting: Setting, population: Population) -> Events:
    """Run one draw and return its events; raises the errors of :func:`run_batch`."""
    if len(population.A) != 1:
        raise ValueError(f"one run is wanted, not {len(population.A)}")
    _, (events,) = run_with_events(setting, population)
    return events


def run_with_events(
    setting: Setting, population: Population
) -> tuple[NDArray[np.void], list[Events]]:
    """Run every draw; return its row, as :func:`run_batch` does, and its events.

    There is room for ``setting.most_events`` events of each draw; only the used part takes memory.
    """
    rows, log = _run(setting, population, setting.most_events)
    assert log.states is not None
    events = rows["transmissions"].tolist()
    parts = zip(events, log.event_s, log.delivered, log.states, strict=True)
    return rows, [Events(*(part[:count] for part in own)) for count, *own in parts]


def _run(
    setting: Setting, population: Population, places: int
) -> tuple[NDArray[np.void], EventLog]:
    _check(setting, population)
    if (gone_s := vanishes_s(setting.trigger)) < setting.horizon_s:
        raise vanished(gone_s)
    names = stream_names(setting.link, UPDATE_LINK)
    keys = np.zeros((len(population.A), len(names), 2), np.int64)
    for stage, name in enumerate(names):
        keys[:, stage] = stream_keys(population.loss_seeds, *name)
    simulation = ExactSimulation(
        setting.H, setting.K, setting.trigger, horizon_s=setting.horizon_s,
        known_start=setting.known_start, link=LinkState(setting.link, 0, UPDATE_LINK),
        Q=setting.Q, R=setting.R, settle=setting.settle, most_events=setting.most_events,
    )  # fmt: skip
    return simulation.runs(*population[:3], keys, places, states=places > 0)


def _check(setting: Setting, population: Population) -> None:
    k, n, m = len(population.loss_seeds), len(setting.H), len(setting.K)
    wanted = {
        "H": (setting.H, (n, n)),
        "K": (setting.K, (m, n)),
        "trigger.weight": (setting.trigger.weight, (n, n)),
        "Q": (setting.Q, (n, n)),
        "R": (setting.R, (m, m)),
        "A": (population.A, (k, n, n)),
        "B": (population.B, (k, n, m)),
        "x0": (population.x0, (k, n)),
        "loss_seeds": (population.loss_seeds, (k,)),
    }
    for name, (array, shape) in wanted.items():
        if array is not None and array.shape != shape:
            raise ValueError(f"{name}: expected the shape {shape}, found {array.shape}")
    if population.loss_seeds.dtype != np.uint64:
        raise ValueError(f"loss_seeds: expected uint64, found {population.loss_seeds.dtype}")
    if timeless(setting.link) != setting.link:
        raise CallerError(
            "network.impairments: a batch knows losses and corruption only; "
            "leave out what takes time"
        )
    rule = setting.trigger
    for form in (rule.form, *([rule.dynamic_variable.gain] if rule.dynamic_variable else [])):
        for part in form:
            if part.shape[1] != 2 * n:
                raise ValueError(f"trigger: expected {2 * n} columns, found {part.shape[1]}")
