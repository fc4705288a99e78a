"""Random loops: model, plant, trigger, observer and controller that fit together."""

import io
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.plants.linear import NAMED_MODELS
from tests.fuzz.scenarios.chances import Chances, Table

_SHIPPED = Path(__file__).parents[3] / "scenarios"
_NONLINEAR = ("cart_pole", "dc_motor", "four_tank", "quadrotor_hover", "kinematic_car", "sine_pendulum")
"""Shipped scenarios whose plant is not linear."""
_RATES_HZ = (30.0, 50.0, 60.0, 100.0, 120.0, 144.0, 200.0, 250.0, 333.3, 500.0)
_FASTEST_PER_S = 30.0
"""Largest eigenvalue of a closed loop, per second."""

TRIGGER_CODE = """import numpy as np

class Threshold:
    def __init__(self, limit, names=""):
        self.limit = limit

    def start(self, t_s, x):
        self.x = x.copy()

    def test(self, t_s, x, e_s):
        return float(np.linalg.norm(e_s)), self.limit
"""
CONTROLLER_CODE = """import numpy as np

class Gain:
    def __init__(self, K, limit=1e3, clipped=True):
        self.K, self.limit = np.array(K), limit

    def on_tick(self, t_s, x_c):
        return np.clip(self.K @ x_c, -self.limit, self.limit)
"""


class Model(NamedTuple):
    """Â, B̂ and K of a drawn model."""

    A: Matrix
    B: Matrix
    K: Matrix

    @property
    def n(self) -> int:
        """The number of states."""
        return len(self.A)

    @property
    def m(self) -> int:
        """The number of inputs."""
        return self.B.shape[1]


def loop(of: Chances, *, acknowledged: bool) -> tuple[Table, Model]:
    """Return the tables of a loop, and its model."""
    if of.chance(0.1):
        return _own_equations(of, acknowledged=acknowledged) if of.flag() else _nonlinear(of)
    table, model = _model(of)
    content: Table = {"model": table}
    of.put(content, 0.3, "outputs", lambda: _outputs(of, model.n))
    of.put(content, 0.4, "mode", lambda: of.one_of("model", "zoh"))
    content["plant"] = plant = _plant(of, model)
    outputs = model.n
    if of.chance(0.25):
        outputs = of.integer(1, model.n)
        content["observer"] = observer(of, model, plant, outputs)
    _measurement(of, model, plant, outputs, observed="observer" in content)
    content["trigger"] = trigger(of, model, _measured_s(plant))
    of.put(content, 0.8, "controller", lambda: controller(of, model, plant, acknowledged=acknowledged))
    if of.chance(0.15) and "observer" not in content:
        loads(of, model, content)
    elif of.chance(0.1) and not content.keys() & {"observer"} and not plant.get("measurement"):
        controller_states(of, model, content)
    return content, model


def controller_states(of: Chances, model: Model, content: Table) -> None:
    """Replace the controller of a loop without an observer by one that filters x, and adds the result."""
    k, table = of.integer(1, 2), dict(content.get("controller", {}))
    for key in ("kind", "file", "name", "parameters"):
        table.pop(key, None)
    if of.flag():
        content["controller"] = table
        integral(of, model, content)
        return
    matrices = {
        "A": -of.between(1.0, 5.0) * np.eye(k),
        "B": 0.1 * np.eye(k, model.n),
        "C": 0.1 * np.eye(model.m, k),
    }
    of.put(matrices, 0.5, "D", lambda: model.K)
    if of.flag():
        rows = {key: np.array(matrix).tolist() for key, matrix in matrices.items()}
        content["controller"] = {"kind": "state_space", **table, **rows}
    else:
        file = of.file("controller", ".npz", npz(matrices))
        content["controller"] = {"kind": "state_space", "file": file, **table}
    content["trigger"] = {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.2, "floor": 0.05}


def integral(of: Chances, model: Model, content: Table) -> None:
    """Add the integral of a state that the input can move, with a slow and stable gain."""
    names = [f"state {index}" for index in range(model.n)]
    moved = np.linalg.pinv(model.A + model.B @ model.K) @ model.B
    index = int(np.argmax(np.linalg.norm(moved, axis=1)))
    direction = moved[index] / max(np.linalg.norm(moved[index]), 1e-9) ** 2
    gain = np.hstack([model.K, -0.05 * direction[:, None]])
    given = of.one_of(names[index], [names[index]])
    content["model"] |= {"state_names": names, "integral": given, "gain": gain.tolist()}
    content["trigger"] = {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.02, "floor": 0.05}


def loads(of: Chances, model: Model, content: Table) -> None:
    """Add unknown loads to a loop without an observer."""
    table, plant, k = content["model"], content["plant"], model.m
    table["load"] = "input"
    if of.flag():
        k = 1
        table["load"] = [[entry] for entry in of.row(model.n)]
        table["state_names"] = [f"state {index}" for index in range(model.n)]
        table["hold"] = table["state_names"][:1]
    of.put(plant, 0.8, "load", lambda: of.row(k, 0.5))
    of.put(plant, 0.3, "load_halfwidth", lambda: of.positives(k, 0.5))
    change = {"at_s": of.between(0.1, 0.9), "load": of.row(k, 0.5)}
    of.put(plant, 0.3, "load_changes", lambda: [change])
    content["trigger"] = {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.2, "floor": 0.05}


def _nonlinear(of: Chances) -> tuple[Table, Model]:
    """Return a shipped loop with other parameters of its plant, and another trigger."""
    name = of.one_of(*_NONLINEAR)
    shipped = tomllib.loads((_SHIPPED / f"{name}.toml").read_text())
    content = {key: shipped[key] for key in ("model", "plant", "controller") if key in shipped}
    system = content["plant"]["system"]
    if "file" in system:
        code = (_SHIPPED / system["file"]).read_text()
        system["file"] = of.file("equations", ".py", code)
        of.put(system, 0.5, "parameters", lambda: _PARAMETERS[system["name"]])
    else:
        system |= _varied(of, system["kind"])
    content["plant"]["initial_state"] = [
        of.between(0.5, 1.0) * value for value in content["plant"]["initial_state"]
    ]
    content["plant"]["rate_hz"] = of.one_of(200.0, 250.0, 500.0)
    model = Model(*(np.array(content["model"][key]) for key in ("A", "B", "gain")))
    threshold = {key: shipped["trigger"][key] for key in ("weight", "beta", "alpha_per_s", "floor")
                 if key in shipped["trigger"]}  # fmt: skip
    content["trigger"] = threshold | {"policy": "decaying"}
    return content, model


def _own_equations(of: Chances, *, acknowledged: bool) -> tuple[Table, Model]:
    """Return a loop whose plant is a class with equations: those of a model, and other terms."""
    model = _random_model(of)
    while model.n > 3:
        model = _random_model(of)
    z, inputs = [f"z[{i}]" for i in range(model.n)], [f"u[{j}]" for j in range(model.m)]
    if of.chance(0.3):
        inputs = [f"np.clip({name}, -{of.size(1.0, 50.0)}, {of.size(1.0, 50.0)})" for name in inputs]
    rates = []
    for row in np.hstack([model.A, model.B]).tolist():
        terms = [f"{factor} * {name}" for factor, name in zip(row, [*z, *inputs], strict=True)]
        rates.append(" + ".join(terms) + "".join(_term(of, z) for _ in range(of.integer(0, 1))))
    rates[0] += _term(of, z)
    code = f"""import numpy as np

class Own:
    def derivative(self, t_s, z, u):
        return [
            {", ".join(rates)},
        ]
"""
    names = {
        key: [f"{key} {index}" for index in range(count)]
        for key, count in zip("xu", model.B.shape, strict=True)
    }
    table: Table = {key: matrix.tolist() for key, matrix in zip(("A", "B", "gain"), model, strict=True)}
    content: Table = {"model": table | {"state_names": names["x"], "input_names": names["u"]}}
    content["plant"] = plant = _plant(of, model)
    for key in ("draw", "A", "B", "file", "names", "uncertainty_A", "uncertainty_B"):
        plant.pop(key, None)
    plant["system"] = {"kind": "python", "file": of.file("own", ".py", code), "name": "Own"}
    if of.chance(0.9):  # others are refused
        kept = [each for each in plant.pop("disturbances", []) if each.get("at", "input") == "input"]
        plant |= {"disturbances": kept} if kept else {}
    plant["initial_state"] = of.row(model.n, 0.3)
    of.put(content, 0.3, "outputs", lambda: _outputs(of, model.n))
    of.put(content, 0.3, "mode", lambda: of.one_of("model", "zoh"))
    content["trigger"] = trigger(of, model, _measured_s(plant))
    of.put(content, 0.8, "controller", lambda: controller(of, model, plant, acknowledged=acknowledged))
    if of.chance(0.15):
        controller_states(of, model, content)
    return content, model


def _term(of: Chances, z: list[str]) -> str:
    """Return a term that is 0 at 0 and not linear, with its sign."""
    first, other, size = of.one_of(*z), of.one_of(*z), of.size(0.01, 0.5)
    return of.one_of(
        f" + {size} * (np.sin({first}) - {other})",
        f" + {size} * (np.cos({first}) - 1)",
        f" - {size} * np.tanh({first} / {of.size(0.01, 0.3)})",
        f" - {size} * np.sign({first})",
        f" - {size} * {first} ** 3",
        f" - {size} * {first} * abs({other})",
        f" + {size} * np.cos(t_s) * {first}",
        f" + {size} * np.arctan({first} * {other})",
        f" + {size} * (np.sqrt(np.maximum({first} + 4, 0)) - 2)",
        f" + {size} * {first} / (2 + {other} ** 2)",
    )


_PARAMETERS = {"Pendulum": {"length_m": 1.01}, "KinematicCar": {"wheelbase_m": 2.62, "steering_s": 0.1}}


def _varied(of: Chances, kind: str) -> Table:
    """Return the parameters of a kind of plant, each about its default or left out."""
    from noack.scenario.sections import PLANTS

    table: Table = {}
    for key, field in PLANTS[kind].model_fields.items():
        if key != "kind" and of.chance(0.4):
            table[key] = _about(of, field.default)
    return table


def _about(of: Chances, value: Any) -> Any:
    if isinstance(value, tuple):
        return [_about(of, entry) for entry in value]
    return float(f"{value * of.between(0.99, 1.01):.9g}")


def _model(of: Chances) -> tuple[Table, Model]:
    if of.chance(0.12):
        return _named_model(of)
    model = _random_model(of)
    matrices = {"A": model.A, "B": model.B, "gain": model.K}
    table: Table = {}
    if of.chance(0.12):
        names = {"A": "dynamics", "B": "inputs", "gain": "F"}
        stored = {names[key]: matrix for key, matrix in matrices.items()}
        table |= {"file": of.file("model", ".npz", npz(stored)), "names": names}
    else:
        table |= {key: matrix.tolist() for key, matrix in matrices.items()}
    of.put(table, 0.2, "state_names", lambda: [f"state {index}" for index in range(model.n)])
    of.put(table, 0.1, "state_units", lambda: ["rad", *[""] * (model.n - 1)])
    of.put(table, 0.2, "input_names", lambda: [f"input {index}" for index in range(model.m)])
    if of.chance(0.03):
        table["allow_unstable"] = True
        if "gain" in table:
            table["gain"] = (0.9 * model.K).tolist()
            model = model._replace(K=0.9 * model.K)
    return table, model


def _outputs(of: Chances, n: int) -> list[Table]:
    """Return one or two outputs, with factors of the states."""
    outputs = []
    for index in range(of.integer(1, 2)):
        table: Table = {"name": f"output {index}", "row": [of.between(0.5, 2.0) for _ in range(n)]}
        of.put(table, 0.5, "unit", lambda: "m")
        of.put(table, 0.5, "allowed", lambda: of.between(0.01, 1.0))
        outputs.append(table)
    return outputs


def _named_model(of: Chances) -> tuple[Table, Model]:
    name = of.one_of(*NAMED_MODELS)
    parameters = {
        "lane_following": {"look_ahead": of.between(38.0, 45.0)},
        "double_integrator": {"stiffness": of.between(0.5, 2.0), "damping": of.between(1.0, 2.0)},
    }
    table: Table = {"name": name}
    of.put(table, 0.6, "parameters", lambda: parameters[name])
    named = NAMED_MODELS[name](**table.get("parameters", {}))
    return table, Model(named.A, named.B, named.K)


def _random_model(of: Chances) -> Model:
    """Return a random model with the gain of a linear-quadratic regulator."""
    while True:
        n, m = of.integer(1, 4), of.integer(1, 2)
        growth = 0.3 if of.gentle else of.one_of(0.3, 1.0, 3.0)
        A = np.array([of.row(n, growth) for _ in range(n)])
        B = np.array([of.row(m) for _ in range(n)])
        weight = of.size(0.1, 10.0)
        try:
            P = scipy.linalg.solve_continuous_are(A, B, np.eye(n), weight * np.eye(m))
        except (np.linalg.LinAlgError, ValueError):
            continue
        K = np.round(-(B.T @ P) / weight, 6)
        closed = np.linalg.eigvals(A + B @ K)
        if closed.real.max() < -0.1 and np.abs(closed).max() < _FASTEST_PER_S and np.abs(K).max() < 100:
            return Model(A, B, K)


def npz(arrays: dict[str, Matrix]) -> bytes:
    """Return the content of an .npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _plant(of: Chances, model: Model) -> Table:
    n, m = model.n, model.m
    plant: Table = {"initial_state": of.row(n)}
    of.put(plant, 0.2, "system", lambda: {"kind": "linear"})
    _draw(of, model, plant)
    of.put(plant, 0.2, "initial_state_halfwidth", lambda: of.positives(n, 0.5))
    of.put(plant, 0.9, "rate_hz", lambda: of.one_of(*_RATES_HZ[3 if of.gentle else 0 :]))
    of.put(plant, 0.1 if of.gentle else 0.3, "measure_every", lambda: of.integer(1, 4))
    of.put(plant, 0.35, "disturbances", lambda: [_disturbance(of, n, m) for _ in range(of.integer(1, 2))])
    of.put(plant, 0.2, "watchdog", lambda: _watchdog(of))
    return plant


def _draw(of: Chances, model: Model, plant: Table) -> None:
    """Draw the plant: the model, one in a box around it, or given matrices."""
    kind = of.one_of("nominal", "nominal", "uniform", "vertex", "given")
    if kind == "nominal":
        of.put(plant, 0.3, "draw", lambda: kind)
        return
    plant["draw"] = kind
    share = of.size(0.001, 0.01 if of.gentle else 0.05)
    if kind == "given":
        near_A, near_B = (M * (1 + share * of.generator.uniform(-1, 1, M.shape)) for M in model[:2])
        if of.chance(0.3):
            plant |= {"file": of.file("plant", ".npz", npz({"F": near_A, "G": near_B})),
                      "names": {"A": "F", "B": "G"}}  # fmt: skip
        else:
            plant |= {"A": near_A.tolist(), "B": near_B.tolist()}
        return
    boxes = {"uncertainty_A": np.abs(model.A) * share, "uncertainty_B": np.abs(model.B) * share}
    for key in of.one_of(("uncertainty_A",), ("uncertainty_B",), tuple(boxes)):
        plant[key] = boxes[key].tolist()


def _disturbance(of: Chances, n: int, m: int) -> Table:
    at = of.one_of("input", "state")
    entries = m if at == "input" else n
    size = of.size(0.001, 0.1)
    sine: Table = {"kind": "sine", "amplitude": of.row(entries, size), "hz": of.size(0.1, 20.0)}
    of.put(sine, 0.5, "phase_rad", lambda: of.between(0.0, 6.0))
    step: Table = {"kind": "step", "amplitude": of.row(entries, size)}
    of.put(step, 0.5, "from_s", lambda: of.between(0.0, 1.0))
    of.put(step, 0.5, "until_s", lambda: of.between(1.1, 2.0))
    table = of.one_of(
        {"kind": "gaussian", "std": of.positives(entries, size)},
        {"kind": "uniform", "bound": of.positives(entries, size)},
        sine,
        step,
    )
    return table | ({} if at == "input" and of.flag() else {"at": at})


def _watchdog(of: Chances) -> Table:
    table: Table = {}
    of.put(table, 0.6, "timeout_s", lambda: of.size(0.04, 0.5))
    of.put(table, 0.8, "policy", lambda: of.one_of("hold", "zero", "model"))
    return table


def _measurement(of: Chances, model: Model, plant: Table, outputs: int, *, observed: bool) -> None:
    table: Table = {}
    if observed:
        table["C"] = (
            np.eye(model.n)[:outputs].tolist() if of.flag() else [of.row(model.n) for _ in range(outputs)]
        )
    elif of.chance(0.05):
        table["C"] = np.eye(model.n).tolist()
    of.put(table, 0.2, "noise_std", lambda: of.positives(outputs, of.size(1e-4, 1e-2)))
    of.put(table, 0.2, "noise_bound", lambda: of.positives(outputs, of.size(1e-4, 1e-2)))
    if table:
        plant["measurement"] = table


def _measured_s(plant: Table) -> float:
    """Return the time between measurements."""
    return float(plant.get("measure_every", 1) / plant.get("rate_hz", 500.0))


def observer(of: Chances, model: Model, plant: Table, outputs: int) -> Table:
    """Return an observer for some outputs."""
    n, m = model.n, model.m
    table: Table = {}
    of.put(table, 0.3, "initial_estimate", lambda: of.row(n))
    if of.flag():
        table |= {"kind": "kalman", "initial_std": [of.size(0.1, 1.0) for _ in range(n)]}
        if of.chance(0.3):
            table["Q"] = np.diag([of.size(1e-6, 1e-3) for _ in range(n)]).tolist()
        else:
            table["process_std"] = [of.size(0.01, 1.0) for _ in range(n)]
            of.put(table, 0.5, "input_std", lambda: [of.size(0.01, 1.0) for _ in range(m)])
        if of.chance(0.3):
            table["R"] = np.diag([of.size(1e-5, 1e-2) for _ in range(outputs)]).tolist()
        else:
            table["noise_std"] = [of.size(1e-3, 0.1) for _ in range(outputs)]
        return table
    table["kind"] = "luenberger"
    if of.chance(0.2):
        table["gain"] = (0.5 * np.eye(n)[:, :outputs]).tolist()
        of.put(table, 0.5, "first_gain", lambda: np.eye(n)[:, :outputs].tolist())
    elif n >= 2 and of.chance(0.4):
        table["poles_per_s"] = [[-8.0, 3.0], *(-10.0 - 2 * index for index in range(n - 2))]
    else:
        table["poles_per_s"] = [-10.0 - 3.0 * index for index in range(n)]
    return table


def controller(of: Chances, model: Model, plant: Table, *, acknowledged: bool) -> Table:
    """Return a controller of the model."""
    table: Table = {}
    rate_hz = plant.get("rate_hz", 500.0)
    rates_hz = _RATES_HZ[3 if of.gentle else 1 :]
    table["rate_hz"] = rate_hz if of.chance(0.6) else of.one_of(*rates_hz)
    of.put(table, 0.4, "phase", lambda: of.between(0.0, 0.99))
    of.put(table, 0.15, "safe_input", lambda: of.row(model.m, 0.1))
    carries_model = plant.get("watchdog", {}).get("policy") == "model"
    if of.chance(0.06) and not carries_model:
        of.put(table, 0.3, "predictions", lambda: 1)
        of.put(table, 0.3, "timeout_input", lambda: of.one_of("safe", "hold"))
        code = of.file("controller", ".py", CONTROLLER_CODE)
        return table | {"kind": "python", "file": code, "name": "Gain", "parameters": {"K": model.K.tolist()}}
    of.put(table, 0.3, "kind", lambda: "linear")
    of.put(table, 0.05 if of.gentle else 0.15, "update_timeout_s", lambda: of.size(0.1, 1.0))
    of.put(table, 0.15, "timeout_input", lambda: of.one_of("safe", "hold"))
    if not acknowledged and not carries_model:
        of.put(table, 0.15, "setpoint", lambda: setpoint(of, model))
    of.put(table, 0.2, "predictions", lambda: of.integer(1, 4))
    return table


def setpoint(of: Chances, model: Model) -> list[float]:
    """Return an equilibrium of the model."""
    null = scipy.linalg.null_space(np.hstack([model.A, model.B]))
    state: list[float] = (null @ of.generator.standard_normal(null.shape[1]))[: model.n].tolist()
    return state


def trigger(of: Chances, model: Model, measured_s: float, *, combined: bool = False) -> Table:
    """Return a trigger of any policy."""
    policies: list[Callable[[Chances, Model, float], Table]] = [
        _absolute, _decaying, _dynamic, _lyapunov, _mixed, _periodic, _quadratic, _relative,
        _self_triggered, _send_on_area,
    ]  # fmt: skip
    if not combined:
        policies += [_combined, _combined, _python, _decaying, _decaying]
    table = of.one_of(*policies)(of, model, measured_s)
    if "rule" not in table:
        of.put(table, 0.2, "weight", lambda: _weight(of, model.n))
    return table


def _weight(of: Chances, n: int) -> list[list[float]]:
    matrix = np.diag([of.size(0.3, 3.0) for _ in range(n)]) + 0.2 * np.array([of.row(n) for _ in range(n)])
    if np.linalg.cond(matrix) > 100:
        matrix = np.eye(n) * 2.0
    rows: list[list[float]] = np.round(matrix, 6).tolist()
    return rows


def _decaying(of: Chances, model: Model, measured_s: float) -> Table:
    rate = -spectral_abscissa(model.A + model.B @ model.K)
    table: Table = {
        "beta": of.size(0.01, 0.5),
        "alpha_per_s": float(f"{abs(rate) * of.between(0.05, 0.9):.6g}"),
    }
    of.put(table, 0.7, "policy", lambda: "decaying")
    of.put(table, 0.4, "floor", lambda: of.size(1e-4, 0.05))
    return table


def _absolute(of: Chances, model: Model, measured_s: float) -> Table:
    return {"policy": "absolute", "delta": of.size(0.005, 0.3)}


def _dynamic(of: Chances, model: Model, measured_s: float) -> Table:
    table: Table = {"policy": "dynamic", "sigma": of.between(0.05, 0.9), "theta_s": of.size(0.01, 1.0),
                    "decay_per_s": of.between(0.0, 2.0)}  # fmt: skip
    of.put(table, 0.5, "eta_0", lambda: of.size(0.01, 1.0))
    of.put(table, 0.3, "Q", lambda: np.diag([of.size(0.5, 2.0) for _ in range(model.n)]).tolist())
    return table


def _lyapunov(of: Chances, model: Model, measured_s: float) -> Table:
    table: Table = {"policy": "lyapunov", "rate_per_s": of.size(0.05, 1.0)}
    of.put(table, 0.3, "Q", lambda: np.diag([of.size(0.5, 2.0) for _ in range(model.n)]).tolist())
    return table


def _mixed(of: Chances, model: Model, measured_s: float) -> Table:
    return {"policy": "mixed", "sigma": of.size(0.01, 0.3), "epsilon": of.size(1e-3, 0.1)}


def _periodic(of: Chances, model: Model, measured_s: float) -> Table:
    periods = of.integer(1, 20) * (1.0 if of.chance(0.8) else 1.3)
    return {"policy": "periodic", "period_s": float(f"{periods * measured_s:.9g}")}


def _quadratic(of: Chances, model: Model, measured_s: float) -> Table:
    if round(measured_s * 1e9) != measured_s * 1e9:  # its period must be whole nanoseconds
        return _relative(of, model, measured_s)
    n = model.n
    Q = np.diag([-of.size(0.001, 0.1)] * n + [1.0] * n)
    table: Table = {"policy": "quadratic", "Q": Q.tolist(),
                    "period_s": float(f"{of.integer(1, 8) * measured_s:.9g}")}  # fmt: skip
    of.put(table, 0.6, "epsilon", lambda: of.size(1e-4, 1e-2))
    of.put(table, 0.4, "heartbeat", lambda: of.integer(0, 20))
    return table


def _relative(of: Chances, model: Model, measured_s: float) -> Table:
    return {"policy": "relative", "sigma": of.size(0.01, 0.5)}


def _self_triggered(of: Chances, model: Model, measured_s: float) -> Table:
    table = _decaying(of, model, measured_s) | {"policy": "self_triggered"}
    table |= {"growth_per_s": of.size(0.1, 5.0), "mismatch_per_s": of.size(0.01, 2.0)}
    table |= {"shortest_s": of.size(0.005, 0.1), "longest_s": of.size(0.2, 2.0)}
    of.put(table, 0.4, "disturbance_per_s", lambda: of.size(0.01, 0.5))
    return table


def _send_on_area(of: Chances, model: Model, measured_s: float) -> Table:
    return {"policy": "send_on_area", "delta_s": of.size(0.001, 0.1)}


def _combined(of: Chances, model: Model, measured_s: float) -> Table:
    rule = trigger(of, model, measured_s, combined=of.chance(0.85))
    while rule["policy" if "policy" in rule else "beta"] == "python":
        rule = trigger(of, model, measured_s, combined=True)
    return {"policy": of.one_of("deadline", "dwell"), "rule": rule, "interval_s": of.size(0.01, 0.5)}


def _python(of: Chances, model: Model, measured_s: float) -> Table:
    code = of.file("trigger", ".py", TRIGGER_CODE)
    return {
        "policy": "python",
        "file": code,
        "name": "Threshold",
        "parameters": {"limit": of.size(0.01, 0.3)},
    }
