"""The policies' tables, and a user's class as a trigger.

Each policy is compared with the rule as it is stated: at measurements in
tests/cosim/simulation/test_whole_loop.py, in continuous time in .../test_exact_simulation.py,
and by the search for the worst pattern in tests/cosim/analysis/adversary/test_sampled_search.py.
"""

import json
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import RunRecord
from cosim.record.run_scenario import write_scenario
from cosim.simulation.continuous import continuous_loop_of
from cosim.simulation.exact_simulation import setting_of
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.scenario.sections import POLICIES
from noack.theory.coverage import nonlinear_because
from noack.trigger_policies.lyapunov import LyapunovSettings
from noack.trigger_policies.policy_settings import ModelMatrices
from tests.helpers.approved import compare_lines, lines_of_error
from tests.helpers.example_rules import TABLES


def test_every_rule_is_in_the_table() -> None:
    assert {table["policy"] for table in TABLES.values()} == POLICIES.keys() - {"python"}


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_lyapunov_function_beyond_rounding_is_refused() -> None:
    """One mode decays 1e16 times as slowly as the other; P is not positive definite as computed."""
    B, K = (
        np.array([[113.33624038521207], [43.17068933023515]]),
        [[-3.896659939542095, -1.4842666344932138]],
    )
    settings = LyapunovSettings(policy="lyapunov", rate_per_s=0.3)
    with pytest.raises(CallerError, match="within rounding"):
        settings.trigger_policy(ModelMatrices(np.zeros((2, 2)), B, K))


# --- a user's class -------------------------------------------------------------------------------

SCENARIOS = Path(__file__).parents[3] / "scenarios"
SEND_ON_DELTA = """
    import numpy as np

    class Delta:
        def __init__(self, delta):
            self.delta = delta

        def start(self, t_s, x):
            pass

        def test(self, t_s, x, e_s):
            return np.linalg.norm(e_s), self.delta
"""


def scenario(folder: Path, code: str, name: str = "Delta", parameters: str = "{}") -> Scenario:
    path = folder / "own.py"
    path.write_text(dedent(code))
    trigger = f'{{policy="python", file="{path}", name="{name}", parameters={parameters}}}'
    overrides = [f"trigger={trigger}", "horizon_s=4.0", "plant.rate_hz=100.0"]
    return resolve(load(SCENARIOS / "lane_following.toml", overrides))


def events(record: RunRecord) -> list[int]:
    rows = record[SENSOR_MEASUREMENT]
    return rows["t_ns"][rows["event"] >= 0].tolist()


@pytest.mark.parametrize("protocol", ["none", "ack"])
def test_a_send_on_delta_class_gives_the_same_run_as_the_policy(tmp_path: Path, protocol: str) -> None:
    own = scenario(tmp_path, SEND_ON_DELTA, parameters="{delta=0.05}")
    network = own.network.model_copy(update={"protocol": protocol})
    own = own.model_copy(update={"network": network})
    built_in = resolve(
        load(
            SCENARIOS / "lane_following.toml",
            ['trigger={policy="absolute", delta=0.05}', "horizon_s=4.0", "plant.rate_hz=100.0"],
        )
    ).model_copy(update={"network": network})
    record, expected = simulate(own), simulate(built_in)
    assert len(events(record)) > 3
    assert events(record) == events(expected)
    rows, others = record[SENSOR_MEASUREMENT], expected[SENSOR_MEASUREMENT]
    different = {name for name in rows.dtype.names if (rows[name] != others[name]).any()}
    assert different <= {"compared"}  # two functions for the same norm
    np.testing.assert_allclose(rows["compared"], others["compared"], rtol=1e-14)


def test_a_run_keeps_the_file_and_replays_with_it(tmp_path: Path) -> None:
    resolved = scenario(tmp_path, SEND_ON_DELTA, parameters="{delta=0.05}")
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    kept = write_scenario(ResolvedRun(resolved), run_dir)
    (tmp_path / "own.py").write_text("class Delta: pass")
    assert (run_dir / "trigger" / "own.py").is_file()
    assert replay(simulate(kept.scenario)).bit_exact
    with pytest.raises(CallerError, match=r"trigger\.file = .*has changed"):
        simulate(resolved)


def test_exact_and_batch_loops_refuse_a_user_trigger_in_one_line(tmp_path: Path) -> None:
    resolved = scenario(tmp_path, SEND_ON_DELTA, parameters="{delta=0.05}")
    for refuses in (continuous_loop_of, setting_of):
        with pytest.raises(CallerError, match="decides at measurements only") as refused:
            refuses(resolved)
        assert "\n" not in str(refused.value)
    assert (nonlinear_because(resolved) or "").endswith("a class of your own decides at measurements only")
    rule = '{policy="python", name="a:B"}'
    with pytest.raises(CallerError, match='"python" cannot be combined'):
        load(
            SCENARIOS / "lane_following.toml",
            [f'trigger={{policy="dwell", interval_s=0.1, rule={rule}}}'],
        )


def test_a_mistake_in_the_class_gives_the_approved_line(tmp_path: Path) -> None:
    compare_lines(
        Path(__file__).with_name("class_mistakes.txt"),
        lambda line: lines_of_error(lambda: simulate(scenario(tmp_path, json.loads(line)))),
    )


def test_a_class_may_return_whether_to_transmit(tmp_path: Path) -> None:
    code = """
        class Delta:
            def start(self, t_s, x):
                self.since_s = t_s

            def test(self, t_s, x, e_s):
                return t_s - self.since_s > 0.4999
    """
    intervals_ns = np.diff(events(simulate(scenario(tmp_path, code))))
    assert len(intervals_ns) > 5
    assert set(intervals_ns) == {500_000_000}
