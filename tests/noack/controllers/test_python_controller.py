"""Users' control laws: the shipped examples against other solvers, whole runs, and mistakes."""

import importlib.util
from pathlib import Path
from textwrap import dedent
from typing import Any

import control
import numpy as np
import pytest
from scipy.optimize import minimize

from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.output_statistics import output_parts
from cosim.output.run_verdict import verdict
from cosim.record.run_record import RunRecord, load_record
from cosim.simulation.virtual_time import simulate, simulate_run
from netem.core.errors import CallerError, ExitStatus
from netem.output.result_tables import Tone
from noack.controllers.controller_settings import ControlModel
from noack.protocol.record_tables import CONTROLLER_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.coverage import require_exact
from tests.helpers.approved import compare_lines, lines_of_error
from tests.helpers.shipped import resolved
from tests.helpers.summaries import summary_of

SCENARIOS = Path(__file__).parents[3] / "scenarios"
EXAMPLES = ("saturated_lqr", "model_predictive")
A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
GAIN = np.array([[-1.0, -np.sqrt(2.0)]])
LIMIT = 0.5


def example(name: str, class_name: str, period_s: float, **parameters: Any) -> Any:
    """An object of a shipped class, started for the double integrator."""
    spec = importlib.util.spec_from_file_location(name, SCENARIOS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made = getattr(module, class_name)(state_weights=[1.0, 0.0], input_weights=[1.0], **parameters)
    made.start(ControlModel(A, B, GAIN, period_s))
    return made


def discrete_gain(period_s: float) -> np.ndarray:
    held = control.c2d(control.ss(A, B, np.eye(2), np.zeros((2, 1))), period_s)
    gain: np.ndarray = control.dlqr(held, np.diag([1.0, 0.0]), np.eye(1))[0]
    return gain


def test_the_regulator_has_another_packages_gain_within_its_limits() -> None:
    law = example("saturated_lqr", "SaturatedLqr", 0.01, limit=[LIMIT])
    x = np.array([0.1, 0.05])
    assert law.on_tick(0.0, x) == pytest.approx(-discrete_gain(0.01) @ x, rel=1e-9)
    assert law.on_tick(0.0, np.array([9.0, 0.0])).tolist() == [-LIMIT]


@pytest.mark.parametrize("x", [(2.0, 0.0), (1.0, -0.5), (-1.0, 0.3), (0.5, 0.45), (0.1, 0.05)])
def test_the_predictive_controller_solves_its_quadratic_programme(x: tuple[float, float]) -> None:
    limits = {"input_limit": [LIMIT], "state_limit": [0.0, LIMIT]}
    law = example("model_predictive", "ModelPredictive", 0.05, horizon=30, **limits)
    x0 = np.array(x)
    bound = {"type": "ineq", "fun": lambda z: law.h - np.abs(law.G @ z + law.E @ x0)}
    optimum = minimize(
        lambda z: 0.5 * z @ law.P @ z + (law.F @ x0) @ z, np.zeros(30), method="SLSQP",
        jac=lambda z: law.P @ z + law.F @ x0, constraints=[bound],
        options={"ftol": 1e-13, "maxiter": 1000},
    )  # fmt: skip
    assert optimum.success
    np.testing.assert_allclose(law.solve(x0), optimum.x, atol=1e-4)


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_run_keeps_the_class_and_is_replayed_bit_for_bit(name: str, tmp_path: Path) -> None:
    for suffix in (".py", ".toml"):
        (tmp_path / f"{name}{suffix}").write_bytes((SCENARIOS / f"{name}{suffix}").read_bytes())
    ending = simulate_run(load(tmp_path / f"{name}.toml", ["horizon_s=2.0"]), tmp_path / "runs")
    assert ending.status == ExitStatus.OK
    (tmp_path / f"{name}.py").unlink()
    assert (ending.run_dir / "controller" / f"{name}.py").is_file()
    assert replay(load_record(ending.run_dir)).bit_exact


def test_mistakes_in_the_settings_give_the_approved_lines() -> None:
    path = SCENARIOS / "saturated_lqr.toml"
    compare_lines(
        Path(__file__).with_name("class_mistakes.txt"),
        lambda setting: lines_of_error(lambda: simulate(resolve(load(path, [setting]))), FILE=path),
    )
    with pytest.raises(CallerError, match=r"^controller\.kind = .*: u is not K x_c; this needs"):
        require_exact(resolve(load(path)))


STEERING = """
    class Steering:
        def __init__(self, own=0.0):
            self.x_r, self.u_r = [own, 0.0], 0.0

        def start(self, model):
            self.K = model.K

        def on_tick(self, t_s, x_c):
            return self.K @ (x_c - self.x_r) + self.u_r

    class Following(Steering):
        def on_reference(self, t_s, x_r, u_r):
            self.x_r, self.u_r = x_r, u_r
"""
POSITION = 'outputs=[{name="position", unit="m", allowed=0.05}]'


def steered(folder: Path, *settings: str) -> RunRecord:
    """A run of the double integrator to x_1 = 2, without losses."""
    (folder / "law.py").write_text(dedent(STEERING))
    of_class = ["controller.kind=python", f"controller.file={folder / 'law.py'}"]
    short = ["horizon_s=12", "network.loss={model='lossless'}", POSITION]
    return simulate(resolved("double_integrator", *of_class, *short, *settings))


def test_a_run_to_a_set_point_that_noack_does_not_know_is_not_called_off_target(tmp_path: Path) -> None:
    record = steered(tmp_path, "controller.name=Steering", "controller.parameters={own=2.0}")
    (output,) = output_parts(record)
    assert (output.target, output.allowed, output.settled_s) == (None, None, None)
    assert output.last == pytest.approx(2.0, abs=0.05)
    summary = summary_of(record, outputs=[output.model_dump()], diverged_at_s=None)
    sentence = verdict(summary)[0]
    assert sentence.tone == Tone.GOOD
    assert "set-point at the end" not in sentence.text
    assert "; their set-point is not known, as a class computes the input" in sentence.text


@pytest.mark.parametrize(
    "setting",
    [
        "controller.setpoint=[2.0, 0.0]",
        'controller.reference=[{kind="step", output="position", value=2.0, from_s=0.0}]',
    ],
)
def test_a_class_follows_the_set_point_and_the_reference_of_the_scenario(
    setting: str, tmp_path: Path
) -> None:
    record = steered(tmp_path, "controller.name=Following", setting)
    linear = simulate(
        resolved("double_integrator", "horizon_s=12", "network.loss={model='lossless'}", POSITION, setting)
    )
    (output,), (expected,) = output_parts(record), output_parts(linear)
    assert output.settled_s is not None
    assert output == expected
    # NumPy may add products in another order than the C core.
    np.testing.assert_allclose(
        record[CONTROLLER_STEP]["u"], linear[CONTROLLER_STEP]["u"], rtol=1e-9, atol=1e-12
    )
    assert replay(record).bit_exact


def test_a_set_point_of_0_is_known_if_it_is_stated(tmp_path: Path) -> None:
    record = steered(tmp_path, "controller.name=Following", "controller.setpoint=[0.0, 0.0]")
    (output,) = output_parts(record)
    assert (output.target, output.allowed) == ("set-point", 0.05)
    assert output.settled_s is not None


CODE = """
    class Law:
        def __init__(self):
            self.updates = []

        def on_update(self, t_s, x):
            {on_update}

        def on_tick(self, t_s, x_c):
            {on_tick}
"""


def run_of(tmp_path: Path, **methods: str) -> RunRecord:
    code = dedent(CODE).format(**{"on_update": "pass", "on_tick": "return [0.0]"} | methods)
    (tmp_path / "law.py").write_text(code)
    settings = [
        f"controller.file={tmp_path / 'law.py'}", "controller.name=Law", "controller.parameters={}",
        "controller.safe_input=[0.25]", "horizon_s=2.0",
    ]  # fmt: skip
    return simulate(resolved("saturated_lqr", *settings))


@pytest.mark.parametrize(
    ("methods", "message"),
    [
        ({"on_tick": "return [0.0, 1.0]"}, "on_tick has shape (2,), expected (1,)"),
        ({"on_tick": "return 'left'"}, "on_tick must have real numbers only"),
        ({"on_tick": "return [float('nan')]"}, "on_tick is not finite: [nan]"),
        ({"on_tick": "x_c[0] = 1.0"}, "assignment destination is read-only (law.py, line 10)"),
        ({"on_update": "raise KeyError('x')"}, "KeyError: 'x' (law.py, line 7)"),
        ({"on_tick": "raise SystemExit(3)"}, "SystemExit: 3 (law.py, line 10)"),
    ],
)
def test_the_safe_input_is_sent_after_a_control_law_fails(
    methods: dict[str, str], message: str, tmp_path: Path
) -> None:
    record = run_of(tmp_path, **methods)
    (notice,) = [notice for notice in record.notices if notice["level"] == "failed"]
    assert notice["text"].startswith('controller.name = "Law": ')
    assert message in notice["text"]
    assert set(record[CONTROLLER_STEP]["u"][:, 0]) <= {0.0, 0.25}
    assert record[CONTROLLER_STEP]["u"][-1] == 0.25
    end = summarise_loop(record, ExitStatus.OK, "").exit
    assert (end.status, message in end.reason) == (ExitStatus.FAILED, True)
