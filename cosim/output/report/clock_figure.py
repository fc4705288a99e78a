"""The figure of the bounds of the clocks' errors, for runs on hosts with different clocks."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cosim.analysis.value_reduction import Reals
from cosim.output import palette
from cosim.output.report import axes as draw
from cosim.output.report.figure_style import printed, styled
from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import CLOCK_TABLES, LOST_NS, OWNER

_ALLOWED = "allowed"


class ClockErrors(NamedTuple):
    """Bounds of the error of a process's clock: k comparisons with the recorder's clock."""

    t_s: Reals
    """(k,)"""
    error_us: Reals
    """(k,) wall µs; NaN: the bound was lost."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(k,) whether the bound was lost."""
        return np.isnan(self.error_us)

    @property
    def largest_us(self) -> float | None:
        """The largest known bound; None without one."""
        known = self.error_us[~self.lost]
        return float(known.max()) if len(known) else None


def clock_errors(record: RunRecord) -> dict[str, ClockErrors]:
    """Return the bounds of the processes whose clock is not the recorder's, by process."""
    found = {}
    for table in CLOCK_TABLES:
        if table not in record.tables:
            continue
        rows = record.columns(table, "t_ns", "error_ns")
        if (rows["error_ns"] != 0).any():
            error_us = np.where(rows["error_ns"] == LOST_NS, np.nan, rows["error_ns"] * 1e-3)
            found[OWNER[table]] = ClockErrors(rows["t_ns"] / NS_PER_S, error_us)
    return found


@styled
def clock_figure(
    errors: Mapping[str, ClockErrors], allowed_us: float, until_s: float | None = None
) -> Figure:
    """Bound of the error of each process's clock over time; it has a gap while it is lost.

    Args:
        errors: by process.
        allowed_us: largest bound with which claims hold; crosses at this height show where a bound
            was lost.
        until_s: end of the time axis; by default the last comparison.
    """
    figure, (axes,) = draw.single(1.9, [*errors, _ALLOWED])
    draw.logarithmic(axes, "y")
    last_s = max((one.t_s.max(initial=0.0) for one in errors.values()), default=0.0)
    last_s = last_s if until_s is None else until_s
    shown = []
    for i, (process, one) in enumerate(errors.items()):
        keep = one.t_s <= last_s
        t_s, error_us, lost = one.t_s[keep], one.error_us[keep], one.lost[keep]
        # The curves often coincide: the first ones are wider, and stay visible under the last.
        style: dict[str, Any] = {
            "color": printed(palette.PROCESSES[process]),
            "zorder": 2 + 0.1 * i,
        }
        width = 1.3 + 1.2 * (len(errors) - 1 - i)
        known_us = draw.finite(error_us, positive=True)
        shown += draw.line(axes, t_s, known_us, process, linewidth=width, **style)
        began = lost & ~np.append(False, lost[:-1])
        lost_us = np.where(began, allowed_us, np.nan)
        draw.marks(axes, t_s, lost_us, size=9.0, marker="x", markeredgewidth=2.0, **style)
    if all(one.largest_us is None for one in errors.values()):
        axes.set_ylim(allowed_us / 10, allowed_us * 10)
    limit = axes.axhline(
        allowed_us, color=printed(palette.THRESHOLD), linewidth=1.2, linestyle=(0, (4, 3))
    )
    axes.set(title="Clocks", xlabel=draw.TIME, ylabel="bound of error [wall µs]")
    draw.legend(axes, [*shown, (limit, _ALLOWED)])
    draw.finish(axes, np.array([0.0, last_s]))
    return figure
