"""The recorder's progress report: counts of the rows received so far."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_events import updates_in
from cosim.record.run_record import Rows
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    LOOP,
    NETEM_PACKET,
    SENSOR_MEASUREMENT,
    effective,
)

_MOST_LINES = 30


class ProgressReport:
    """Fields of :class:`noack.runtime.control_messages.RunProgress`.

    They are those of all loops together; ‖x‖ is the largest.
    """

    def __init__(self, live: str | None) -> None:
        self._fields: dict[str, Any] = {
            "t_s": 0.0, "events": 0, "deliveries": 0, "longest_loss_burst": 0, "x_norm": None,
            "live": live, "warnings": [], "changes": [],
        }  # fmt: skip

    def add_warning(self, text: str) -> None:
        """Add a line, e.g. about void claims; of many, the last says where the others are."""
        lines = self._fields["warnings"]
        if len(lines) < _MOST_LINES:
            lines.append(text)
        elif len(lines) == _MOST_LINES:
            lines.append("further void claims and diverging loops are in the logs of the loops")

    def add_change(self, text: str) -> None:
        """Add a line about a change of runtime parameters."""
        self._fields["changes"].append(text)

    @np.errstate(all="ignore")  # a run may diverge
    def count(self, table: str, rows: Rows) -> None:
        """Count rows of a table."""
        fields = self._fields
        if table == SENSOR_MEASUREMENT:
            fields["t_s"] = int(rows["t_ns"][-1]) / NS_PER_S
            fields["events"] += int((rows["event"] >= 0).sum())
            # Of each loop, the newest state in the batch.
            _, from_end = np.unique(rows[LOOP][::-1], return_index=True)
            newest = rows["x"][len(rows) - 1 - from_end]
            fields["x_norm"] = float(np.linalg.norm(newest, axis=1).max())
        elif table == CONTROLLER_DELIVERY:
            fields["deliveries"] += len(rows)
            # Includes stale updates, which the emulator cannot know in advance.
            self._count_losses(rows["dropouts"])
        elif table == NETEM_PACKET:
            rows = updates_in(rows)[0]
            self._count_losses(rows["consecutive_losses"][~effective(rows["fate"])])

    def _count_losses(self, consecutive: NDArray[np.int64]) -> None:
        longest = int(consecutive.max(initial=0))
        self._fields["longest_loss_burst"] = max(self._fields["longest_loss_burst"], longest)

    def dumps(self) -> str:
        """The report as JSON."""
        return json.dumps(self._fields)
