"""Real processes that serve several loops, of different plants.

A loop that diverges is in cosim/simulation/test_simulated_run.py; exports of several loops
have tests of their own.
"""

import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import load_run
from noack.protocol.wire_format import read_header
from tests.helpers import live_runs as live

pytestmark = pytest.mark.live

DIFFERENT = ("lane", "pendulum-1", "pendulum-2", "mass")
SIZES = {"lane": 4, "pendulum-1": 2, "pendulum-2": 2, "mass": 2}
STEPS = {"lane": 1501, "pendulum-1": 301, "pendulum-2": 301, "mass": 1501}


@pytest.fixture(scope="module")
def different(tmp_path_factory: pytest.TempPathFactory) -> live.Finished:
    """With a change of settings on the way, and a queue that chooses by errors."""
    change = "changes=[{ at_s = 1.5, set = { mansd = 2 } }]"
    queue = '[{kind="rate", rate_bps=300_000, discipline={kind="maximum_error"}}]'
    settings = (
        *live.settings(horizon_s=3.0, network__encrypted=True),
        "--set", change, "--set", f"network.impairments={queue}",
    )  # fmt: skip
    with live.start_runs(tmp_path_factory.mktemp("different")) as start:
        return start(*settings, command=("run", "different_loops")).finish()


def test_all_loops_reach_the_horizon_at_their_rates_and_are_replayed(
    different: live.Finished,
) -> None:
    assert different.status == 0, different.stderr
    run = load_run(different.run_dir)
    assert tuple(run.names) == DIFFERENT
    assert replay(run.network).bit_exact
    for name, record in zip(DIFFERENT, run.loops, strict=True):
        assert replay(record).bit_exact
        steps = record["plant_step"]
        assert (len(steps), steps["x"].shape[1]) == (STEPS[name], SIZES[name])
        assert len(record["sensor_setting"]) == 1
        headers = [read_header(head.tobytes()) for head in record["netem_packet"]["head"]]
        assert all(
            header is not None and header.version == 2 and header.error_level > 0 for header in headers
        )
    assert all(loop["exit"]["status"] == 0 for loop in different.summary["loops"])
