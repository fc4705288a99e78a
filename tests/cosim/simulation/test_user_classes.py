"""Users' controllers and plants: the shipped examples, whole runs, and mistakes."""

import importlib.util
import json
import shutil
from pathlib import Path
from textwrap import dedent
from typing import Any

import control
import numpy as np
import pytest
from scipy.optimize import minimize

from cosim.analysis.replay import replay
from cosim.analysis.summary.run_summary import linearisation, summarise
from cosim.analysis.summary.summary_model import NoLinearisationPart
from cosim.live.finalize import finalize
from cosim.record.run_record import RunRecord, load_record
from cosim.simulation.virtual_time import simulate, simulate_run
from noack.controllers.controller_settings import ControlModel
from noack.core.errors import CallerError, ExitStatus
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.command_line import invoke
from tests.helpers.approved import compare_lines, lines_of_error
from tests.helpers.shipped import resolved
from tests.plant_server.fmus.build import build

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
    found = minimize(
        lambda z: 0.5 * z @ law.P @ z + (law.F @ x0) @ z, np.zeros(30), method="SLSQP",
        jac=lambda z: law.P @ z + law.F @ x0, constraints=[bound],
        options={"ftol": 1e-13, "maxiter": 1000},
    )  # fmt: skip
    assert found.success
    np.testing.assert_allclose(law.solve(x0), found.x, atol=1e-4)


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
        resolve(load(path)).coverage.require_exact()


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
        ({"on_tick": "return 'left'"}, "on_tick is not of real numbers"),
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
    (notice,) = [one for one in record.notices if one["level"] == "failed"]
    assert notice["text"].startswith('controller.name = "Law": ')
    assert message in notice["text"]
    assert set(record[CONTROLLER_STEP]["u"][:, 0]) <= {0.0, 0.25}
    assert record[CONTROLLER_STEP]["u"][-1] == 0.25
    end = summarise(record, ExitStatus.OK, "").exit
    assert (end.status, message in end.reason) == (ExitStatus.FAILED, True)


# --- plants ---------------------------------------------------------------------------------------


PLANT_SCENARIO = """
name = "own"
horizon_s = 1.0
[model]
A = [[0.0, 1.0], [-1.0, 1.0]]
B = [[0.0], [1.0]]
gain = [[-3.0, -5.0]]
[plant]
system = SYSTEM
initial_state = [1.0, 0.0]
[trigger]
beta = 0.05
alpha_per_s = 0.5
floor = 0.002
[network]
mansd = 3
loss = { model = "bernoulli", probability = 0.5 }
"""
FMU = (
    '{ kind = "fmu", file = "models/oscillator.fmu", on_record = ["energy"], '
    'state_variables = ["x0", "x1"], input_variables = ["u"], parameters = PARAMETERS }'
)
PYTHON = '{ kind = "python", file = "models/mine.py", name = "VanDerPol", parameters = PARAMETERS }'
PLANT_CODE = """
class VanDerPol:
    def __init__(self, mu=1.0, broken_at_s=1e9):
        self.mu, self.broken_at_s = mu, broken_at_s

    def derivative(self, t_s, z, u):
        if t_s > self.broken_at_s:
            raise RuntimeError("no more grease")
        return z[1], self.mu * (1 - z[0] ** 2) * z[1] - z[0] + u[0]
"""


def prepared(folder: Path, system: str, parameters: str) -> Path:
    path = folder / "own.toml"
    path.write_text(PLANT_SCENARIO.replace("SYSTEM", system).replace("PARAMETERS", parameters))
    (folder / "models").mkdir()
    (folder / "models" / "mine.py").write_text(PLANT_CODE)
    return path


def simulated(path: Path, horizon_s: float = 1.0) -> Path:
    return simulate_run(load(path, [f"horizon_s={horizon_s}"]), path.parent / "runs").run_dir


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_moves_like_a_python_class_with_the_same_equations(version: int, tmp_path: Path) -> None:
    path = prepared(tmp_path, FMU, "{ mu = 1.0 }")
    build(tmp_path, version).rename(tmp_path / "models" / "oscillator.fmu")
    of_fmu = load_record(simulated(path, 3.0))
    path.write_text(PLANT_SCENARIO.replace("SYSTEM", PYTHON).replace("PARAMETERS", "{ mu = 1.0 }"))
    of_class = load_record(simulated(path, 3.0))
    x = of_fmu[PLANT_STEP]["x"]
    np.testing.assert_allclose(x, of_class[PLANT_STEP]["x"], atol=1e-9)
    assert np.linalg.norm(x[-1]) < 0.2  # the loop is closed
    energy = (x**2).sum(axis=1, keepdims=True) / 2
    np.testing.assert_allclose(of_fmu[PLANT_STEP]["z"], energy, rtol=1e-12)
    assert replay(of_fmu).bit_exact
    assert replay(of_class).bit_exact
    path.write_text(PLANT_SCENARIO.replace("SYSTEM", FMU).replace("PARAMETERS", "{}, initial_variables = []"))
    at_rest = resolve(load(path, ["plant.initial_state=[0.0, 0.0]"]))
    assert isinstance(linearisation(at_rest), NoLinearisationPart)


@pytest.mark.parametrize("kind", ["fmu", "python"])
def test_a_run_stores_its_plant_and_is_replayed_without_the_original(kind: str, tmp_path: Path) -> None:
    path = prepared(tmp_path, FMU if kind == "fmu" else PYTHON, "{ mu = 2.0 }")
    build(tmp_path, 2).rename(tmp_path / "models" / "oscillator.fmu")
    run_dir = simulated(path)
    shutil.rmtree(tmp_path / "models")
    elsewhere = tmp_path / "elsewhere"
    run_dir.rename(elsewhere)
    assert replay(load_record(elsewhere)).bit_exact
    (kept,) = (elsewhere / "plant").iterdir()
    kept.write_bytes(kept.read_bytes() + b"\n")
    record = load_record(elsewhere)  # the record is still readable
    with pytest.raises(CallerError, match="has changed: its SHA-256 is") as refused:
        replay(record)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "parameters", "expected"),
    [
        ("fmu", "{ fail_at_s = 0.5, fail_status = 3 }",
         'the plant failed at 0.502 s: plant.system.file = "oscillator.fmu": fmi2DoStep failed '
         "with status 3 (error). (the spring broke at 0.5)"),
        ("python", "{ broken_at_s = 0.5 }",
         'the plant failed at 0.502 s: plant.system.name = "VanDerPol": RuntimeError: no more '
         "grease (mine.py, line 8)"),
    ],
)  # fmt: skip
def test_a_failed_plant_stops_moving_and_the_run_is_recorded(
    kind: str, parameters: str, expected: str, tmp_path: Path
) -> None:
    path = prepared(tmp_path, FMU if kind == "fmu" else PYTHON, parameters)
    build(tmp_path, 2).rename(tmp_path / "models" / "oscillator.fmu")
    ending = simulate_run(load(path), tmp_path / "runs")
    outcome = finalize(ending, report=False, view=False)
    assert outcome.status == 1
    assert outcome.reason == expected
    record = load_record(ending.run_dir)
    x = record[PLANT_STEP]["x"]
    assert len(x) == 501
    assert np.isfinite(x[:251]).all()
    assert np.isnan(x[251:]).all()
    (notice,) = [one for one in record.notices if one["level"] == "failed"]
    assert notice["t_ns"] == 502_000_000
    assert replay(record).bit_exact
    (loop,) = outcome.summary.loops
    assert loop.rejected_datagrams["sensor"]["not_finite"] > 0
    assert loop.unintended_losses == 0  # what is rejected has arrived


def test_check_describes_the_plant_and_refuses_invalid_settings(tmp_path: Path) -> None:
    path = prepared(tmp_path, PYTHON, "{}")
    done = invoke("check", path)
    assert done.exit_code == 0
    assert "the plant: class VanDerPol of mine.py" in " ".join(done.stdout.split())
    done = invoke("check", path, "--json")
    system: dict[str, Any] = json.loads(done.stdout)["plant"]["system"]
    assert (system["kind"], len(system["sha256"])) == ("python", 64)
    for wrong, expected in (
        (FMU, 'plant.system.file = "models/oscillator.fmu": cannot be read: No such'),
        (FMU.replace('"x0", ', ""), 'plant.system.state_variables = ["x1"]: expected 2 entries'),
        ('{ kind = "python", name = "a b" }', "use an entry point's name, or package.module:Class"),
        (f'{{ kind = "python", name = "a", sha256 = "{64 * "0"}" }}', "give file, too"),
        ('{ kind = "python", file = ".", name = "a" }', "cannot be read: not a regular file"),
    ):
        path.write_text(PLANT_SCENARIO.replace("SYSTEM", wrong).replace("PARAMETERS", "{}"))
        with pytest.raises(CallerError) as refused:
            load(path)
        assert expected in str(refused.value)
