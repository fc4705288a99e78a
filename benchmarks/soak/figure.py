"""The figure of a soak: private memory over time, per process."""

import numpy as np

from benchmarks.soak.flat import warm_up_s
from benchmarks.soak.result import Result
from cosim.output import palette
from cosim.output.figure_description import (
    Axis,
    FigureDescription,
    Line,
    Panel,
    Row,
    Spans,
    time_axis,
)

_HEIGHT_IN = 0.95
_GREY: palette.Colour = (128, 128, 128)


def memory_figure(result: Result) -> FigureDescription:
    """Describe private memory minus its value at the end of the warm-up, in KiB, over the run."""
    rows = []
    for i, (role, watched) in enumerate(result.watched.items()):
        at_s = np.array(watched.at_s)
        kib = np.array([sample.uss_kib for sample in watched.samples])
        warm_s = warm_up_s(watched.length_s)
        began = int(np.searchsorted(at_s, warm_s))
        base = float(kib[min(began, len(kib) - 1)])
        colour = palette.PROCESSES.get(role, palette.SERIES[5 if role == "recorder" else 4])
        judged = kib[began:] - base if began < len(kib) else kib - base
        low, high = min(float(judged.min()), -128.0), max(float(judged.max()), 1024.0)
        margin = 0.05 * (high - low)
        panel = Panel(
            title="" if i else (
                f"{result.name}: private memory since the warm-up (grey); 1 MiB is allowed"
            ),
            items=[
                Spans(begin=np.zeros(1), end=np.array([warm_s]), colour=_GREY, opacity=0.14),
                Line(x=at_s, y=kib - base, colour=colour),
            ],
            x=time_axis(at_s, numbers=i == len(result.watched) - 1, label="wall time [s]"),
            y=Axis(label=f"{role} [KiB]", ends=(low - margin, high + margin)),
        )  # fmt: skip
        rows.append(Row(panels=[panel], height_in=_HEIGHT_IN))
    return FigureDescription(name="memory", rows=rows)
