"""The bounds of the clocks' errors over a run."""

from collections import defaultdict
from typing import Any

import numpy as np

from cosim.analysis.claims.input_origins import Batches, columns
from cosim.analysis.claims.observed_conditions import SampledSeries, clock_cause, lost_cause
from cosim.record.run_record import Rows
from noack.config.run_sections import ClocksSection
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import LOST_NS
from noack.protocol.topology import LOOP_ROLES


class Clocks:
    """Gathers the bounds that the processes recorded; each holds from the time of its row on."""

    def __init__(self, settings: ClocksSection) -> None:
        self._largest_s = settings.largest_error_us * 1e-6
        self._rows: defaultdict[str, Batches] = defaultdict(list)

    def add(self, role: str, rows: Rows) -> None:
        """Add rows of the table about a process's clock, in their order."""
        self._rows[role].append((np.maximum(rows["t_ns"], 0), rows["error_ns"]))

    def observed(self) -> dict[str, Any]:
        """Return what was added since the last call, as fields of ``ObservedConditions``."""
        found: dict[str, SampledSeries] = {}
        for role in LOOP_ROLES:
            t_ns, error_ns = columns(self._rows.pop(role, []), 2)
            t_s, error_s, lost = t_ns * 1e-9, error_ns / NS_PER_S, error_ns == LOST_NS
            found[clock_cause(role)] = SampledSeries(t_s[~lost], error_s[~lost]).in_order()
            found[lost_cause(role)] = SampledSeries(t_s[lost], 0 * t_s[lost]).in_order()
        return {"clocks": found, "largest_clock_error_s": self._largest_s}
