"""The lateness of the processes of a run."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from cosim.analysis.loop_statistics import lateness_us


def test_an_unknown_arrival_at_the_network_has_no_lateness() -> None:
    rows = {"t_ns": np.array([0, 5_000, 9_000]), "now_ns": np.array([2_000, 5_000, 10_000])}
    source = SimpleNamespace(batches=lambda table, columns: [rows])
    record: Any = SimpleNamespace(source=source, scenario=SimpleNamespace(speed=1.0))
    assert lateness_us(record, "netem").tolist() == [2.0, 1.0]
    assert lateness_us(record, "plant").tolist() == [2.0, 0.0, 1.0]
