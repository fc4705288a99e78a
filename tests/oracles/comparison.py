"""A record of a run in virtual time against the reference loop.

The reference gets the fates of the packets from the record's table netem_packet, and computes all
else: x, x̂, x_s, x_c, u, both sides of the trigger's comparison, events, times and numbers.

Numbers must agree to 1e-10 of the largest state, or value of their column, up to their time. Both
round at 1e-16 in each of some 10⁴ operations, which the loop may amplify; the largest difference
found is 3e-12. A comparison of the trigger that is decided by less may turn out differently: there
the comparison of the runs ends.
"""

from typing import Any

import numpy as np

from cosim.record.run_record import Rows, RunRecord
from tests.oracles.reference_run import chance_of, settings_of
from tests.oracles.trigger_rules import Array
from tests.oracles.whole_loop import NONE, Settings, run

TOLERANCE = 1e-10
TIMES = {
    "plant_step": "t_ns",
    "plant_actuation": "t_ns",
    "sensor_measurement": "t_ns",
    "sensor_acknowledgement": "model_t_ns",
    "controller_step": "t_ns",
    "controller_delivery": "model_t_ns",
    "netem_packet": "now_ns",
}
"""The compared tables, each with the column of the time at which its process wrote a row."""


class Comparison:
    """A record and what the reference computes; raises AssertionError if they differ.

    Args:
        record: the record of a run of one loop.
        settings: those of the reference; by default those of the record's scenario.
    """

    def __init__(self, record: RunRecord, settings: Settings | None = None) -> None:
        scenario = record.scenario
        self.rows = {table: record[table] for table in TIMES if table in record.tables}
        chance = chance_of(scenario, self.rows["netem_packet"])
        self.reference = run(settings_of(scenario) if settings is None else settings, chance)
        self.error = 0.0
        """The largest difference, relative to the size of the quantity."""
        steps = self.rows["plant_step"]
        self._steps_ns = steps["t_ns"]
        self._largest = np.maximum.accumulate(np.linalg.norm(steps["x"], axis=1))
        self.tie_ns = self._tie_ns()
        """Time of a comparison of the trigger within rounding, decided differently, or None."""
        assert self.reference.keys() <= self.rows.keys()
        for table, rows in self.rows.items():
            self._compare(table, rows)

    def _size(self, t_ns: Any) -> Any:
        """The largest ‖x‖ until a time."""
        return self._largest[np.searchsorted(self._steps_ns, t_ns, side="right") - 1]

    def _tie_ns(self) -> int | None:
        for row, recorded in zip(
            self.reference["sensor_measurement"], self.rows["sensor_measurement"], strict=False
        ):
            if (row["event"] == NONE) != (recorded["event"] == NONE):
                t_ns, due_ns = row["t_ns"], row["due_ns"]
                gap = abs(row["compared"] - row["threshold"])
                by_sides = row["is_compared"] and gap <= TOLERANCE * self._size(t_ns)
                # A self-triggered event is due at a root, which is not a whole number.
                by_time = due_ns % 1 != 0 and abs(t_ns - due_ns) <= 2
                return t_ns if by_sides or by_time else None
        return None

    def _compare(self, table: str, rows: Rows) -> None:
        computed = self.reference[table]
        if self.tie_ns is not None:
            computed = [row for row in computed if row[TIMES[table]] < self.tie_ns]
            rows = rows[rows[TIMES[table]] < self.tie_ns]
        assert len(computed) == len(rows), table
        for column in rows.dtype.names or () if computed else ():
            if column not in computed[0]:
                assert column in NOT_COMPUTED[table], f"{table}.{column}"
                continue
            own = np.array([row[column] for row in computed])
            if rows[column].dtype.kind == "i":
                np.testing.assert_array_equal(rows[column], own, f"{table}.{column}")
            else:
                self._compare_reals(f"{table}.{column}", rows[TIMES[table]], rows[column], own)

    def _compare_reals(self, name: str, t_ns: Array, recorded: Array, own: Array) -> None:
        largest = np.abs(recorded).reshape(len(recorded), -1).max(axis=1, initial=0.0)
        size = np.maximum(np.maximum.accumulate(largest), self._size(t_ns))
        error = np.abs(recorded - own).reshape(len(own), -1).max(axis=1, initial=0.0) / size
        worst = int(error.argmax())
        self.error = max(self.error, float(error[worst]))
        assert error[worst] <= TOLERANCE, f"{name} at {t_ns[worst]} ns: {recorded[worst]}, {own[worst]}"


NOT_COMPUTED = {table: {"loop", "input", "now_ns"} for table in TIMES} | {
    "netem_packet": {
        "loop", "input", "t_ns", "fate", "consecutive_losses", "release_ns", "copy_ns", "bit",
        "size_bytes", "head",
    }
}  # fmt: skip
