"""The outputs in the summary of a run, against its states."""

import numpy as np
import pytest

from cosim.analysis.summary.output_statistics import output_parts
from cosim.output.run_verdict import verdict
from cosim.simulation.virtual_time import simulate
from tests.helpers.shipped import resolved
from tests.helpers.summaries import summary_of

OUTPUTS = 'outputs=[{name="sum", unit="m", row=[1.0, 0.5], allowed=0.05}, {name="velocity", allowed=1e-9}]'


def test_the_outputs_of_a_run_are_those_of_its_states() -> None:
    record = simulate(
        resolved("double_integrator", "horizon_s=12", "controller.setpoint=[0.5, 0.0]", OUTPUTS)
    )
    (total, rate), steps = output_parts(record), record["plant_step"]
    distances = np.abs(steps["x"] @ [1.0, 0.5] - 0.5)
    assert (total.name, total.unit, total.allowed) == ("sum", "m", 0.05)
    assert total.largest == pytest.approx(distances.max())
    assert total.last == pytest.approx(distances[-1])
    assert total.settled_s is not None
    late = steps["t_ns"] * 1e-9 >= total.settled_s - 1e-9
    assert 0 < late.sum() < len(late)
    assert distances[late].max() <= 0.05 < distances[~late][-1]
    assert rate.settled_s is None
    summary = summary_of(record, outputs=[part.model_dump() for part in (total, rate)])
    first = verdict(summary)[0].text
    assert first.startswith(f"sum was within 0.05 m of its set-point from {total.settled_s:.3g} s on")
    assert "velocity was not within 1e-09 of its set-point at the end" in first
