"""The interface of the batch engine: settings, populations and rows of results.

Everything is in SI units and in the paper's notation; k runs, n states, m inputs.
"""

import math
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous.continuous_loop import vanished
from cosim.simulation.continuous.continuous_run import MAX_EVENTS
from cosim.simulation.continuous.network_fates import timeless
from netem.channel import UPDATE_LINK
from netem.link_state import LinkState, stream_names
from noack.config.resolution import loop_of, policy_of
from noack.config.scenario import Scenario
from noack.core.core_library import address_of, dtype_of
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.core.random_streams import stream_keys
from noack.impairments.link_settings import LinkSettings
from noack.trigger import self_triggered_interval
from noack.trigger.trigger_policy import Policy

_SMALLEST_THRESHOLD = 1e-140
"""Below it, the threshold's square or its significant bits would underflow."""

ROW = np.dtype(
    [
        ("transmissions", np.int64),
        ("deliveries", np.int64),
        ("longest_loss_burst", np.int64),
        ("inter_event_min_s", np.float64),
        ("inter_event_mean_s", np.float64),
        ("settling_s", np.float64),
        ("cost", np.float64),
        ("sup_e_c_scaled", np.float64),
        ("final_norm", np.float64),
        ("diverged_at_s", np.float64),
        ("status", np.int64),
    ]
)
"""The row of a run; NaN where a number is not defined.

transmissions, deliveries: numbers of events and of delivered updates, until the end or the failure.
longest_loss_burst: largest number of consecutive losses, until then.
inter_event_min_s, inter_event_mean_s: minimum and mean inter-event time; NaN below two events.
settling_s: the last time at which ‖x‖ > settle ‖x(0)‖; NaN if this holds at the horizon.
cost: ∫ xᵀQx + uᵀRu dt over the horizon, u = K x_c.
sup_e_c_scaled: the supremum over the horizon of ‖W e_c‖ e^{αt}, with the left limits at events. Its
relative error is at most 1e-10 (certified, not sampled). Without a known start, it begins at
event 0. α is the threshold's decay rate if the threshold decays from the start of the run, else 0.
final_norm: ‖x‖ at the horizon.
diverged_at_s: end of a diverged run, as in :mod:`cosim.simulation.continuous.continuous_loop`.
status: a value of :mod:`cosim.simulation.batch.batch_status`; unless it is OK, the measures of the
whole run are NaN.
"""


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
    trigger: Policy
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
        trigger=policy_of(resolved),
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

    The memory for the events is 9 bytes times ``setting.most_events`` for each draw.
    """
    rows, log = _run(setting, population, setting.most_events)
    counts = rows["transmissions"].tolist()
    return rows, [
        Events(log.event_s[run, :events], log.delivered[run, :events])
        for run, events in enumerate(counts)
    ]


def _run(setting: Setting, population: Population, room: int) -> tuple[NDArray[np.void], Any]:
    from cosim.simulation.batch import batch_data, vector_lanes
    from cosim.simulation.batch.batch_rule import rule_of
    from cosim.simulation.batch.quadratic_crossing import squares_of
    from cosim.simulation.batch.taylor import DEGREES, HIGHEST

    _check(setting, population)
    n, m = len(setting.H), len(setting.K)
    rule, terms = setting.trigger.trigger_rule(n), HIGHEST + 1
    system = batch_data.BatchSystem(
        H=_columns(setting.H),
        K=_columns(setting.K),
        weight=_columns(setting.trigger.weight),
        Q=_columns(setting.Q),
        R=_columns(setting.R),
        inverse=np.append(0.0, 1.0 / np.arange(1.0, 2 * terms + 1)),
        H_k=np.empty((terms + 1) * n * n),
        rule=rule_of(rule),
        fading_per_s=float(rule.fading_per_s),
        horizon_s=float(setting.horizon_s),
        known_start=bool(setting.known_start),
        first_delivered=setting.link.first_delivered,
        settle=float(setting.settle),
        most_events=int(setting.most_events),
    )
    names = stream_names(setting.link, UPDATE_LINK)
    keys = np.zeros((len(population.A), len(names), 2), np.int64)
    for stage, name in enumerate(names):
        keys[:, stage] = stream_keys(population.loss_seeds, *name)
    draws = batch_data.Draws(
        A=_columns(population.A), B=_columns(population.B), x0=_flat(population.x0), keys=keys
    )
    states = ("x_c", "e_c", "d", "x", "error", "weighted", "x_scaled")
    space = batch_data.BatchMemory(
        E=np.empty(n * n),
        A_k=np.empty((terms + 1) * n * n),
        X_k=np.empty((terms + 1) * n * n),
        reach_s=np.empty(len(DEGREES)),
        measured_s=np.empty(len(DEGREES)),
        u=np.empty(terms * m),
        u_scaled=np.empty(terms * m),
        squares=np.empty(2 * terms),
        sizes=np.empty(terms + 1),
        **{name: np.empty(terms * max(n, m)) for name in states},
    )
    rows = np.zeros(len(population.A), ROW)
    shape = (len(population.A), room)
    log = batch_data.EventLog(np.empty(shape), np.empty(shape, np.bool_))
    link, network = _network(setting.link)
    batch = batch_data.Batch(
        vector_lanes.width(n), vector_lanes.width(m), system, draws, network, space, log,
    )  # fmt: skip
    _compiled()(batch, squares_of(setting.trigger, n), rows)
    del link  # the compiled code has used its memory
    return rows, log


def _network(link: LinkSettings) -> tuple[LinkState, Any]:
    """Return the link with room for one flow, and what the compiled code has of it."""
    from cosim.simulation.batch.batch_data import LossTable

    state = LinkState(link, 0, UPDATE_LINK)
    decisions = np.zeros(1, dtype_of("noack_decision"))
    return state, LossTable(address_of(state.core), decisions)


@cache
def _compiled() -> Any:
    from cosim.simulation.batch import (
        batch_data,
        batch_rule,
        batch_run,
        batch_status,
        integral_crossing,
        level_crossing,
        norm_crossing,
        piece_measures,
        quadratic_crossing,
        taylor,
        vector_lanes,
    )
    from cosim.simulation.compiled_runs import compile_kept

    modules: tuple[ModuleType, ...] = (
        self_triggered_interval, batch_status, vector_lanes, taylor, norm_crossing,
        integral_crossing, level_crossing, batch_rule, batch_data, quadratic_crossing,
        piece_measures, batch_run,
    )  # fmt: skip
    return compile_kept(batch_run.run_many, "batch", modules)


def _flat(array: NDArray[Any]) -> NDArray[np.float64]:
    return np.ascontiguousarray(array, dtype=np.float64).ravel()


def _columns(matrices: NDArray[Any] | None) -> NDArray[np.float64]:
    """Return all matrices in column-major order in one array; an empty array for None."""
    return np.empty(0) if matrices is None else _flat(np.swapaxes(matrices, -1, -2))


def _check(setting: Setting, population: Population) -> None:
    from cosim.simulation.batch.quadratic_crossing import squares_of

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
    rule = setting.trigger.trigger_rule(n)
    for form in (rule.form, *([rule.dynamic_variable.gain] if rule.dynamic_variable else [])):
        for part in form:
            if part.shape[1] != 2 * n:
                raise ValueError(f"trigger: expected {2 * n} columns, found {part.shape[1]}")
    if rule.integrates and squares_of(setting.trigger, n) is not None:
        raise ValueError("trigger: a batch integrates ‖W e_s‖ only, without a grid")
    if rule.from_event or rule.rate_per_s == 0 or rule.floor >= _SMALLEST_THRESHOLD:
        return
    vanishes_s = math.log(rule.level / _SMALLEST_THRESHOLD) / rule.rate_per_s
    if vanishes_s < setting.horizon_s:
        raise vanished(vanishes_s, _SMALLEST_THRESHOLD)
