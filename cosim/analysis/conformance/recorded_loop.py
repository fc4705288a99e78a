"""What is read of a loop's record for its trace, whatever its document is.

Times, events and the origins of inputs are read of all steps. States and inputs are read of a sample of a
long run, so that they need little memory.
"""

import math

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.conformance.input_origins import PlantInputs, plant_inputs
from cosim.record.rows import Rows, concatenate_rows, pack_rows, with_columns
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from netem.core.row_operations import all_entries
from noack.protocol.record_tables import CONTROLLER_STEP, NO_SEQUENCE, PLANT_STEP, SENSOR_MEASUREMENT

Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]
MOST_STEPS, _WINDOW = 12_500, 25
"""Steps of the plant that are compared in all numbers, at most, and consecutive ones of these."""


class RecordedLoop:
    """What a record says of a loop.

    Args:
        record: of the loop.
        inputs: of its plant, if they are known.
        until_s: what happened later is left out.
        most_steps: of a run with more steps a sample is read, evenly spread.

    Raises:
        CallerError: the record is too short.
    """

    def __init__(
        self,
        record: RunRecord,
        inputs: PlantInputs | None = None,
        until_s: float = math.inf,
        most_steps: int = MOST_STEPS,
    ) -> None:
        self.inputs = plant_inputs(record) if inputs is None else inputs
        self.knows_start = record.scenario.network.initial_sync == "known_state"
        until_ns = math.inf if until_s == math.inf else round(until_s * NS_PER_S)
        count = int(np.searchsorted(self.inputs.t_ns, until_ns, "right"))
        if count < 2:
            raise CallerError("a measurement is not one of a step of the plant")
        self.t_ns = self.inputs.t_ns[:count]
        """Times of the plant's steps, (steps,)."""
        self.is_sampled = _sample(count, most_steps)
        """Of which steps more is known, (steps,)."""
        self.sampled = np.flatnonzero(self.is_sampled)
        """Their numbers, (k,)."""
        self._read_steps(record)
        self._read_measurements(record)
        self._read_ticks(record)

    def _read_steps(self, record: RunRecord) -> None:
        is_recorded, kept, first = list[Flags](), [], 0
        dtype = with_columns(record.tables[PLANT_STEP], ("x", "u"))
        for batch in record.batches(PLANT_STEP, ("x", "u")):
            rows = pack_rows(batch[: len(self.t_ns) - first], dtype)
            is_recorded.append(all_entries(np.isfinite(rows["x"])))
            kept.append(rows[self.is_sampled[first : first + len(rows)]])
            first += len(rows)
        self.is_recorded: Flags = np.concatenate(is_recorded)
        """Whether x is, (steps,)."""
        sampled = concatenate_rows(kept, dtype)
        self.x, self.u = sampled["x"], sampled["u"]
        """(k, n) and (k, m)."""

    def _read_measurements(self, record: RunRecord) -> None:
        """Read those of steps that are sampled, and of all events."""
        names, steps, events, kept = ("t_ns", "x", "x_s", "event"), list[Numbers](), list[Numbers](), []
        dtype = with_columns(record.tables[SENSOR_MEASUREMENT], names)
        for batch in record.batches(SENSOR_MEASUREMENT, names):
            at = np.searchsorted(self.t_ns, batch["t_ns"])
            inside = int(np.searchsorted(at, len(self.t_ns)))
            at, rows = at[:inside], batch[:inside]
            if not (self.t_ns[at] == rows["t_ns"]).all():
                raise CallerError("a measurement is not one of a step of the plant")
            steps.append(at)
            events.append(rows["event"].copy())
            kept.append(pack_rows(rows[self.is_sampled[at] | (rows["event"] != NO_SEQUENCE)], dtype))
        self.test_steps: Numbers = np.concatenate([np.zeros(0, np.int64), *steps])
        """The steps that were measured, (measurements,)."""
        self.events: Numbers = np.concatenate([np.zeros(0, np.int64), *events])
        """The number of the event of each measurement, (measurements,)."""
        self.measured = concatenate_rows(kept, dtype)
        """``t_ns``, ``x``, ``x_s`` and ``event`` of measurements at steps that are sampled, and of events."""

    def _read_ticks(self, record: RunRecord) -> None:
        wanted = np.unique(self.inputs.actuation[self.sampled])

        def is_wanted(rows: Rows) -> Flags:
            at = np.searchsorted(wanted, rows["sequence"])
            return np.asarray(wanted[np.minimum(at, len(wanted) - 1)] == rows["sequence"])

        self.ticks = record.columns(CONTROLLER_STEP, "sequence", "model_t_ns", "x_c", where=is_wanted)
        """``sequence``, ``model_t_ns`` and ``x_c`` of the inputs of steps that are sampled."""


def _sample(steps: int, most: int) -> Flags:
    """Return which steps are compared in all numbers, (steps,): at most about ``most``, evenly spread."""
    if steps <= most:
        return np.ones(steps, dtype=bool)
    starts = np.linspace(0, steps - _WINDOW, max(most // _WINDOW, 1)).astype(np.int64)
    found = np.zeros(steps, dtype=bool)
    found[(starts[:, None] + np.arange(_WINDOW)).ravel()] = True
    return found
