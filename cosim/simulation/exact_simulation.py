"""The exact simulator of the core (native/exact/): its structures, filled and read.

Everything is in SI units and in the paper's notation; n states, m inputs. A state of
the loop is (x, e_s, e_c) with e_s = x_s − x and e_c = x_c − x, of shape (3, n).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.link_state import LinkState
from noack.core.core_library import CData, core, dtype_of, ffi, pointer_to
from noack.core.core_memory import CoreMemory
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.trigger.trigger_rule import TriggerRule, fill_rule

ROW = dtype_of("noack_exact_row")
"""The row of a run: ``noack_exact_row`` of native/noack.h."""

OK: int = core.NOACK_EXACT_OK
DIVERGED: int = core.NOACK_EXACT_DIVERGED
TOO_MANY_EVENTS: int = core.NOACK_EXACT_TOO_MANY_EVENTS
UNDECIDED: int = core.NOACK_EXACT_UNDECIDED

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


class Segments(NamedTuple):
    """What follows k states up to their next event, before its reset, or to the horizon."""

    t_s: Vector
    states: NDArray[np.float64]
    """(k, 3, n)"""
    auxiliaries: Vector
    """η or the integral, (k,)."""
    events: NDArray[np.int64]
    """1: an event, (k,)."""
    values: Vector
    """Of the measure, (k,); NaN of a run that fails."""
    at_s: Vector
    """When a supremum is attained, (k,)."""
    statuses: NDArray[np.int64]


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
        numbers: further fields of the structure.

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
            raise CallerError(
                f"plant: exact simulation has at most {_MOST_ENTRIES} states and inputs"
            )
        self.n, self.m, self._link, self._memory = n, m, link, CoreMemory()
        self.core: CData = ffi.new("noack_exact *")
        """The structure, as the core's functions take it."""
        fill_rule(self.core.rule, trigger, n, self._memory)
        self._memory.fill(self.core, {
            "n": n, "m": m, "H": H, "K": K, "horizon_s": horizon_s, "known_start": known_start,
            "most_events": 2**62, "fading_per_s": trigger.fading_per_s, "fading_until_s": np.inf,
            **numbers,
        })  # fmt: skip
        if link is not None:
            self.core.link = link.core
            self.core.first_delivered = link.settings.first_delivered
        elif delivered is not None:
            fates = self._memory.keep(np.array(delivered, np.uint8))
            self.core.fate_count, self.core.fates = len(fates), pointer_to(fates, "uint8_t *")
        self.core.scratch = self._memory.zeros(core.noack_exact_scratch(self.core))
        mistake = core.noack_exact_check(self.core)
        if mistake != ffi.NULL:
            raise ValueError(ffi.string(mistake).decode())

    def runs(
        self, A: Matrix, B: Matrix, x0: Matrix, keys: NDArray[np.int64] | None = None,
        places: int = 0, *, states: bool = False,
    ) -> tuple[NDArray[np.void], EventLog]:  # fmt: skip
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
        self.core.event_places = places
        for begin in range(0, k, _RUNS_AT_ONCE):
            part = slice(begin, min(begin + _RUNS_AT_ONCE, k))
            self.core.event_s = pointer_to(log.event_s[part], "double *")
            self.core.delivered = pointer_to(log.delivered[part], "uint8_t *")
            if log.states is not None:
                self.core.states = pointer_to(log.states[part], "double *")
            core.noack_exact_runs(
                self.core,
                part.stop - begin,
                *(pointer_to(one[part], "double *") for one in (A, B, x0)),
                ffi.NULL if keys is None else pointer_to(keys[part], "int64_t *"),
                pointer_to(rows[part], "noack_exact_row *"),
            )
        return rows, log

    def segments(
        self, A: Matrix, B: Matrix, t_s: Vector, states: NDArray[np.float64],
        auxiliaries: Vector | None = None,
    ) -> Segments:  # fmt: skip
        """Follow a plant from k states, (k, 3, n), just after events at times (k,)."""
        k = len(t_s)
        found = Segments(
            np.array(t_s, np.float64), np.array(states, np.float64, order="C"),
            np.zeros(k) if auxiliaries is None else np.array(auxiliaries, np.float64),
            np.zeros(k, np.int64), np.zeros(k), np.zeros(k), np.zeros(k, np.int64),
        )  # fmt: skip
        plant = (pointer_to(np.ascontiguousarray(part, np.float64), "double *") for part in (A, B))
        kinds = ["double *"] * 3 + ["int64_t *"] + ["double *"] * 2 + ["int64_t *"]
        core.noack_exact_segments(self.core, *plant, k, *map(pointer_to, found, kinds))
        return found

    def sample(
        self, A: Matrix, B: Matrix, start_s: Vector, starts: NDArray[np.float64], t_s: Vector
    ) -> NDArray[np.float64]:
        """Return the states, (k, 3, n), at ascending times from the first start on.

        A start is a state just after an event, (starts, 3, n), at an ascending time; the last one
        up to a time applies. States are NaN where a plant is too fast to be followed.
        """
        states = np.empty((len(t_s), 3, self.n))
        arrays = [np.ascontiguousarray(part, np.float64) for part in (A, B, start_s, starts, t_s)]
        *known, times = (pointer_to(array, "double *") for array in arrays)
        core.noack_exact_sample(
            self.core, *known[:2], len(start_s), *known[2:], len(t_s), times,
            pointer_to(states, "double *"),
        )  # fmt: skip
        return states
