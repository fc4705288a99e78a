"""Every policy at measurements, against the rules as they are stated; a user's class as a trigger.

The table of all policies is in tests/trigger_rules.py. Here each is applied at measurements; in
tests/cosim/simulation/batch/test_exact_events.py in continuous time; in
tests/cosim/analysis/adversary/test_worst_patterns.py by the search for the worst pattern.
"""

from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_directory import write_scenario
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import continuous_loop_of
from cosim.simulation.exact_simulation import setting_of
from cosim.simulation.virtual_time import simulate
from noack.core.core_library import CoreMemory, core, ffi
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.scenario.sections import POLICIES
from noack.trigger.deadline import DeadlineSettings
from noack.trigger.lyapunov import LyapunovSettings
from noack.trigger.policy_settings import ModelMatrices
from noack.trigger.trigger_rule import TriggerDecision, TriggerRule, fill_rule, rule_rows
from tests.approved import lines_of_error
from tests.oracles.trigger_rules import Trigger
from tests.trigger_rules import TABLES, drawn, rule_from


class CoreTrigger:
    """A policy that native/loop/trigger.c applies to n states."""

    def __init__(self, rule: TriggerRule, n: int) -> None:
        self._memory, self._n = CoreMemory(), n
        self._rule, self._state = ffi.new("noack_trigger_rule *"), ffi.new("noack_trigger_state *")
        fill_rule(self._rule, rule, n, self._memory)
        self._state.auxiliary = self._rule.initial
        self._scratch = self._memory.zeros(2 * n + rule_rows(rule))

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event."""
        core.noack_trigger_start(*self._arguments(t_ns, x), self._scratch)

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        """Decide whether a measurement is an event."""
        sides = np.zeros(2)
        event = core.noack_trigger_test(
            *self._arguments(t_ns, x), self._vector(e_s),
            ffi.cast("double *", sides.ctypes.data), self._scratch,
        )  # fmt: skip
        return TriggerDecision(bool(event), *sides.tolist())

    def _arguments(self, t_ns: int, x: Vector) -> tuple[object, ...]:
        return self._rule, self._state, self._n, t_ns, self._vector(x)

    def _vector(self, values: Vector) -> object:
        return ffi.new("double[]", values.tolist())


N, MS = 2, 10**6


def samples(seed: int, k: int) -> tuple[list[int], Vector]:
    """Times every 10 ms, and z = (x, e_s) on smooth curves with a growing error."""
    rng = np.random.default_rng(seed)
    t_ns = 10 * MS * np.arange(1, k + 1)
    phase, rate = rng.uniform(0, 6, 2 * N), rng.uniform(0.2, 3, 2 * N)
    z = np.sin(phase + np.outer(t_ns * 1e-9, rate))
    z[:, N:] *= (t_ns * 1e-9)[:, None] * rng.choice([0.01, 0.1, 1.0])
    return t_ns.tolist(), z


def test_every_rule_is_in_the_table() -> None:
    assert {table["policy"] for table in TABLES.values()} == POLICIES.keys() - {"python"}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", TABLES)
def test_the_core_decides_as_the_rule_is_stated(name: str, seed: int) -> None:
    rng, start = np.random.default_rng(seed), np.array([0.5, -0.3])
    table = drawn(TABLES[name], rng, N, np.array([[2.0, 0.5], [0.0, 1.0]]) if seed % 2 else None)
    A, B, K = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[-1.0, -1.5]])
    rule = rule_from(table, ModelMatrices(A, B, K))
    trigger, stated = CoreTrigger(rule, N), Trigger(table, A + B @ K, B @ K)

    def begin(t_ns: int, x: Vector) -> None:
        trigger.start(t_ns, x)
        stated.event(t_ns, x)
        stated.measured(t_ns, x, np.zeros(N))

    begin(0, start)
    for t_ns, z in zip(*samples(seed, 400), strict=True):
        found = trigger.test(t_ns, z[:N], z[N:])
        stated.measured(t_ns, z[:N], z[N:])
        left, right = stated.sides(t_ns, z[:N], z[N:])
        assert (found.left, found.right) == pytest.approx((left, right), rel=1e-9, abs=1e-12)
        if abs(left - right) > 1e-9 or left == right == 0.0:
            exceeds = left > right and stated.counts(t_ns, stated.rule)
            assert found.event == (exceeds or t_ns >= stated.due_ns(stated.rule))
        if found.event:
            begin(t_ns, z[:N])


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


def test_the_same_threshold_from_a_later_origin() -> None:
    rule = {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.25}
    deadline = DeadlineSettings(policy="deadline", rule=rule, interval_s=1.0)
    assert deadline.at_origin(3.0).rule.beta == pytest.approx(0.5 * np.exp(-0.75), rel=1e-12)


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
    found, expected = simulate(own), simulate(built_in)
    assert len(events(found)) > 3
    assert events(found) == events(expected)
    rows, others = found[SENSOR_MEASUREMENT], expected[SENSOR_MEASUREMENT]
    different = {name for name in rows.dtype.names if (rows[name] != others[name]).any()}
    assert different <= {"compared"}  # two functions for the same norm
    np.testing.assert_allclose(rows["compared"], others["compared"], rtol=1e-14)


def test_a_run_keeps_the_file_and_replays_with_it(tmp_path: Path) -> None:
    resolved = scenario(tmp_path, SEND_ON_DELTA, parameters="{delta=0.05}")
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    kept = write_scenario(resolved, run_dir)
    (tmp_path / "own.py").write_text("class Delta: pass")
    assert (run_dir / "trigger" / "own.py").is_file()
    assert replay(simulate(kept)).bit_exact
    with pytest.raises(CallerError, match=r"trigger\.file = .*has changed"):
        simulate(resolved)


def test_exact_and_batch_loops_refuse_a_user_trigger_in_one_line(tmp_path: Path) -> None:
    resolved = scenario(tmp_path, SEND_ON_DELTA, parameters="{delta=0.05}")
    for refuses in (continuous_loop_of, setting_of):
        with pytest.raises(CallerError, match="decides at measurements only") as refused:
            refuses(resolved)
        assert "\n" not in str(refused.value)
    assert resolved.coverage.beyond_theory == resolved.trigger.beyond_exact
    rule = '{policy="python", name="a:B"}'
    with pytest.raises(CallerError, match='"python" cannot be combined'):
        load(
            SCENARIOS / "lane_following.toml",
            [f'trigger={{policy="dwell", interval_s=0.1, rule={rule}}}'],
        )


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("x = 1", "LookupError: own.py has no Delta"),
        ("class Delta:\n  def start(self, t_s, x): pass", "TypeError: it has no method test"),
        ("class Delta:\n  def __init__(self, gain): pass", "TypeError: Delta.__init__() missing 1"),
        ("class Delta:\n  def start(self, t_s, x): x[0] = 1\n  def test(self, *given): return True",
         "ValueError: assignment destination is read-only (own.py, line 2)"),
        ("class Delta:\n  def start(self, t_s, x): pass\n  def test(self, *given): return None",
         "TypeError: test(t_s, x, e_s) must return True, False or a pair of numbers"),
        ("class Delta:\n  def start(self, t_s, x): pass\n  def test(self, *given): return 1 / 0",
         "ZeroDivisionError: division by zero (own.py, line 3)"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_class_gives_one_line(tmp_path: Path, code: str, expected: str) -> None:
    (line,) = lines_of_error(lambda: simulate(scenario(tmp_path, code)))
    assert line.startswith(f'trigger.name = "Delta": {expected}')


def test_a_class_may_return_whether_to_transmit(tmp_path: Path) -> None:
    code = """
        class Delta:
            def start(self, t_s, x):
                self.since_s = t_s

            def test(self, t_s, x, e_s):
                return t_s - self.since_s > 0.4999
    """
    found = np.diff(events(simulate(scenario(tmp_path, code))))
    assert len(found) > 5
    assert set(found) == {500_000_000}
