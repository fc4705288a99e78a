"""What a run shows of each output that its scenario states."""

from collections.abc import Iterator

import numpy as np

from cosim.analysis.summary.summary_model import OutputPart
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.outputs import LoopOutput
from noack.scenario.resolution import loop_of


def output_parts(record: RunRecord) -> list[OutputPart]:
    """Return the distances of the stated outputs from what they follow, over the steps of the plant."""
    if record.scenario.outputs is None:
        return []
    return [_output_part(record, output) for output in record.scenario.loop_outputs()]


def _output_part(record: RunRecord, output: LoopOutput) -> OutputPart:
    largest, last, outside_s = 0.0, None, None
    for t_s, distances in output_distances(record, output):
        largest, last = float(np.maximum(largest, distances.max())), float(distances[-1])
        if output.allowed is not None and len(outside := np.flatnonzero(~(distances <= output.allowed))):
            outside_s = float(t_s[outside[-1]])
    settled_s = None
    if output.allowed is not None and last is not None and last <= output.allowed:
        period_s = record.scenario.timing.plant_period_ns / NS_PER_S
        settled_s = 0.0 if outside_s is None else outside_s + period_s
    return OutputPart(
        name=output.name,
        unit=output.unit,
        allowed=output.allowed,
        target=record.scenario.controller.target,
        largest=largest,
        last=last,
        settled_s=settled_s,
    )


def output_distances(
    record: RunRecord, output: LoopOutput
) -> Iterator[tuple["np.ndarray[tuple[int], np.dtype[np.float64]]", ...]]:
    """Yield times in s and |y − r|, (k,) each."""
    row, reference = np.array(output.row), loop_of(record.scenario).reference
    for steps in record.batches(PLANT_STEP, ("t_ns", "x")):
        if len(steps):
            x = steps["x"] if reference is None else steps["x"] - reference.states(steps["t_ns"])
            yield steps["t_ns"] / NS_PER_S, np.abs(x @ row)
