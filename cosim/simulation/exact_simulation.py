"""The core's exact simulator (native/exact/): its structures, filled and read; many runs at once.

Everything is in SI units and in the paper's notation; k runs, n states, m inputs. A state of
the loop is (x, e_s, e_c) with e_s = x_s − x and e_c = x_c − x, of shape (3, n).

:class:`ExactSimulation` is what runs share, as the core takes it. :func:`run_batch` runs a
:class:`Population` of plants, initial states and losses under one :class:`Setting`.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import CData
from netem.core.errors import CallerError
from netem.core.random_streams import stream_keys
from netem.impairments.kinds.corrupt import Corrupt
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState, stream_names
from noack.core.core_library import core, dtype_of, ffi, new_handle, new_structure, pointer_to
from noack.core.linear_systems import Matrix, Vector
from noack.machines.run_channel import UPDATE_LINK
from noack.scenario.resolution import loop_of, rule_of
from noack.scenario.scenario import Scenario
from noack.theory.coverage import require_exact
from noack.trigger_policies.trigger_rule import TriggerRule, new_rule

ROW = dtype_of("noack_exact_row")
"""The row of a run: ``noack_exact_row`` of native/exact/public.h."""

OK: int = core.NOACK_EXACT_OK
DIVERGED: int = core.NOACK_EXACT_DIVERGED
TOO_MANY_EVENTS: int = core.NOACK_EXACT_TOO_MANY_EVENTS
UNDECIDED: int = core.NOACK_EXACT_UNDECIDED

MAX_EVENTS = 100_000
"""Largest number of events of a run, by default."""
_SMALLEST_THRESHOLD = 1e-140
"""Below it, the threshold's square or its significant bits would underflow."""
_MOST_ENTRIES: int = core.NOACK_EXACT_ENTRIES
_RUNS_AT_ONCE = 1000
"""Between two calls of the core a program can be interrupted."""


class EventLog(NamedTuple):
    """The events of k runs, each with the same number of places."""

    event_s: NDArray[np.float64]
    """(k, places)"""
    delivered: NDArray[np.bool_]
    """(k, places)"""
    states: NDArray[np.float64] | None
    """(k, places, 3, n) just before the events; None: not wanted."""


class ExactSimulation:
    """What runs share, as the core's ``noack_exact``.

    Args:
        H: matrix of both models between updates, (n, n).
        K: gain, (m, n).
        trigger: the trigger rule.
        horizon_s: end of the runs.
        known_start: both models start from x(0); else from 0, and event 0 happens at t = 0.
        link: decides which updates arrive.
        delivered: without a link, whether the update of each event arrives; later ones arrive.
        numbers: further fields of ``noack_exact_settings``.

    Raises:
        CallerError: the loop has more than 64 states or inputs.
        ValueError: the numbers do not fit together.
    """

    def __init__(
        self,
        H: Matrix,
        K: Matrix,
        trigger: TriggerRule,
        *,
        horizon_s: float,
        known_start: bool,
        link: LinkState | None = None,
        delivered: NDArray[np.bool_] | None = None,
        **numbers: object,
    ) -> None:
        m, n = K.shape
        if max(n, m) > _MOST_ENTRIES:
            raise CallerError(f"plant: exact simulation has at most {_MOST_ENTRIES} states and inputs")
        self.n, self.m, self._link = n, m, link
        self._rule = new_rule(trigger, n)
        settings = new_structure("noack_exact_settings", {
            "n": n, "m": m, "H": H, "K": K, "rule": self._rule, "horizon_s": horizon_s,
            "known_start": known_start, "most_events": 2**62, "fading_per_s": trigger.fading_per_s, **numbers,
        })  # fmt: skip
        # The network: a link, or whether each update arrives.
        if link is not None:
            settings.link, settings.first_delivered = link.core, link.settings.first_delivered
        elif delivered is not None:
            fates = np.array(delivered, np.uint8)
            settings.fate_count, settings.fates = len(fates), pointer_to(fates, "uint8_t *")
        self.core: CData = new_handle("exact", settings)
        """The simulation, as the core's functions take it."""

    def runs(
        self,
        A: Matrix,
        B: Matrix,
        x0: Matrix,
        keys: NDArray[np.int64] | None = None,
        places: int = 0,
        *,
        states: bool = False,
    ) -> tuple[NDArray[np.void], EventLog]:
        """Run k draws; a row depends bit-exactly on what the runs share and its own draw only.

        Args:
            A: true plants, (k, n, n).
            B: true plants, (k, n, m).
            x0: x(0), (k, n).
            keys: keys of the random streams of the link's stages, (k, stages, 2).
            places: room for the events of each run.
            states: whether the log has states.
        """
        k = len(A)
        A, B, x0 = (np.ascontiguousarray(part, np.float64) for part in (A, B, x0))
        rows = np.zeros(k, ROW)
        log = EventLog(
            np.empty((k, places)),
            np.empty((k, places), np.bool_),
            np.empty((k, places, 3, self.n)) if states else None,
        )
        # The core writes the rows and logs of some runs per call, so that Ctrl-C can interrupt.
        for begin in range(0, k, _RUNS_AT_ONCE):
            part = slice(begin, min(begin + _RUNS_AT_ONCE, k))
            states_of = ffi.NULL if log.states is None else pointer_to(log.states[part], "double *")
            event_s, arrived = _pointer(log.event_s[part]), pointer_to(log.delivered[part], "uint8_t *")
            core.noack_exact_runs(
                self.core,
                part.stop - begin,
                *(pointer_to(population[part], "double *") for population in (A, B, x0)),
                ffi.NULL if keys is None else pointer_to(keys[part], "int64_t *"),
                pointer_to(rows[part], "noack_exact_row *"),
                ffi.new("noack_exact_log *", (places, event_s, arrived, states_of)),
            )
        return rows, log

    def sample(
        self, A: Matrix, B: Matrix, start_s: Vector, starts: NDArray[np.float64], t_s: Vector
    ) -> NDArray[np.float64]:
        """Return the states, (k, 3, n), at ascending times from the first start on.

        A start is a state just after an event, (starts, 3, n), at an ascending time; the last one
        up to a time applies. States are NaN where a plant is too fast to be followed.
        """
        A, B, start_s, starts, t_s = (
            np.ascontiguousarray(part, np.float64) for part in (A, B, start_s, starts, t_s)
        )
        states = np.empty((len(t_s), 3, self.n))
        core.noack_exact_sample(
            self.core, _pointer(A), _pointer(B), _states(start_s, starts), _states(t_s, states)
        )
        return states


def _states(t_s: Vector, states: NDArray[np.float64]) -> CData:
    fields = {"count": len(t_s), "t_s": _pointer(t_s), "states": _pointer(states)}
    return ffi.new("noack_exact_states *", fields)


def _pointer(array: NDArray[np.float64] | NDArray[np.int64]) -> CData:
    return pointer_to(array, "double *" if array.dtype == np.float64 else "int64_t *")


def vanishes_s(rule: TriggerRule) -> float:
    """Return the time from which a threshold is too small to compute with; infinity for never."""
    if rule.from_event or rule.rate_per_s == 0 or rule.floor >= _SMALLEST_THRESHOLD:
        return math.inf
    return math.log(rule.level / _SMALLEST_THRESHOLD) / rule.rate_per_s


def vanished_error(from_s: float) -> CallerError:
    """Return the error of a threshold that decays too far."""
    return CallerError(
        f"trigger: from {from_s:g} s on the threshold is below {_SMALLEST_THRESHOLD:g}, where "
        "errors are within rounding; give trigger.floor or a shorter horizon"
    )


def timeless(settings: LinkSettings) -> LinkSettings:
    """Return the settings of a link that apply in the paper's loop: losses and corruption."""
    impairments = tuple(
        impairment for impairment in settings.impairments if isinstance(impairment, LossOf | Corrupt)
    )
    return settings.model_copy(update={"impairments": impairments})


def left_out(settings: LinkSettings) -> str:
    """Return the kinds of a link's impairments that do not exist in the paper's loop, as text."""
    stages = timeless(settings).impairments
    return ", ".join(stage.kind for stage in settings.impairments if stage not in stages)


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
    require_exact(resolved)
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


def run_with_events(setting: Setting, population: Population) -> tuple[NDArray[np.void], list[Events]]:
    """Run every draw; return its row, as :func:`run_batch` does, and its events.

    There is room for ``setting.most_events`` events of each draw; only the used part takes memory.
    """
    rows, log = _run(setting, population, setting.most_events)
    assert log.states is not None
    events = rows["transmissions"].tolist()
    parts = zip(events, log.event_s, log.delivered, log.states, strict=True)
    return rows, [Events(*(part[:count] for part in arrays)) for count, *arrays in parts]


def _run(setting: Setting, population: Population, places: int) -> tuple[NDArray[np.void], EventLog]:
    _check(setting, population)
    if (gone_s := vanishes_s(setting.trigger)) < setting.horizon_s:
        raise vanished_error(gone_s)
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
    shapes = {
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
    for name, (array, shape) in shapes.items():
        if array is not None and array.shape != shape:
            raise ValueError(f"{name}: expected the shape {shape}, found {array.shape}")
    if population.loss_seeds.dtype != np.uint64:
        raise ValueError(f"loss_seeds: expected uint64, found {population.loss_seeds.dtype}")
    if timeless(setting.link) != setting.link:
        raise CallerError(
            "network.impairments: a batch supports losses and corruption only; leave out what takes time"
        )
    rule = setting.trigger
    for form in (rule.form, *([rule.dynamic_variable.gain] if rule.dynamic_variable else [])):
        for part in form:
            if part.shape[1] != 2 * n:
                raise ValueError(f"trigger: expected {2 * n} columns, found {part.shape[1]}")
