"""What PLANT may be on the command line: a class, a kind of plant, or what a kind gives a name."""

import ast
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from cosim.shipped_files import find_shipped, shipped_names
from netem.core import toml_file
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, did_you_mean, one_line, why
from netem.core.extension_points import missing_extension
from netem.core.settings_section import ReadTable, Table
from noack.core.linear_systems import Matrix, Vector
from noack.plants.linear import LinearSettings
from noack.plants.plant_settings import PlantSettings, PlantStart, PlantSystem, name_and_unit, plain_name
from noack.plants.python_plant import PythonPlantSettings
from noack.plants.systems.linearisation import STEP_NS
from noack.scenario import scenario_file
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.sections import PLANTS
from noack.settings.user_files import with_absolute_path

_LARGEST_TRIED_SIZE = 16
"""Largest number of states and of inputs that is tried with a class that names neither."""
_KINDS = sorted(kind for kind, plant in PLANTS.items() if plant.scenario and plant is not LinearSettings)
"""Kinds that name a plant by themselves."""
_FORMS = (
    f"PLANT is FILE.py:Class, a kind of plant ({', '.join(_KINDS)}), a scenario, or a file that "
    "`noack linearise` or `noack gain` wrote"
)


@dataclass(frozen=True)
class PlantReference:
    """A plant, its numbers of states and inputs, and what is known about its runs."""

    label: str
    """As the user named it."""
    settings: ReadTable
    """Values by the keys of a scenario."""
    system: PlantSettings
    n: int
    m: int
    names: tuple[tuple[str, ...] | None, tuple[str, ...] | None]
    """Of states and inputs."""
    rates: Mapping[str, float]
    """``rate_hz`` and ``measure_every`` of its plant, if they are given."""
    initial_state: tuple[float, ...] | None = None
    units: tuple[str, ...] = ()
    """Of the states, if they are known."""
    allowed: ReadTable = field(default_factory=dict)
    """Allowed errors of states, by their names."""
    matrices: tuple[Matrix, Matrix] | None = None
    """A and B of a linear plant."""
    model_matrices: tuple[Matrix, Matrix] | None = None
    """Â and B̂ of its model, which sensor and controller use."""
    outputs: Mapping[str, Vector] = field(default_factory=dict)
    """The rows of a scenario's outputs, (n,), by their names."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return self.names[0] or tuple(f"x_{i}" for i in range(1, self.n + 1))

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.names[1] or tuple(f"u_{j}" for j in range(1, self.m + 1))

    @property
    def step_ns(self) -> int:
        """Step of its motion: its own, if it makes no others, or 10 ms."""
        return round(NS_PER_S / self.rate_hz) if self.system.has_own_step else STEP_NS

    @property
    def rate_hz(self) -> float:
        """Its steps per second; that of a scenario by default."""
        return self.rates.get("rate_hz", 500.0)

    def system_at(self, x0: Vector) -> PlantSystem:
        """Return the system at an initial state."""
        A, B = self.matrices or (np.zeros((self.n, self.n)), np.zeros((self.n, self.m)))
        return self.system.system(PlantStart(x0, A, B, self.step_ns))


def plant_reference(
    label: str,
    settings: ReadTable,
    sizes: tuple[int | None, int | None] = (None, None),
) -> PlantReference:
    """Return the plant that a text names.

    Args:
        label: the text.
        settings: values by the keys of a scenario; those that begin with ``plant.`` are used.
        sizes: numbers of states and inputs, if they are known.

    Raises:
        CallerError: there is no such plant.
    """
    if (table := _system_table(label)) is None:
        return _of_scenario(label, settings)
    kind, content = table["kind"], dict[str, object](plant={"system": table})
    for key, value in settings.items():
        if key.startswith("plant."):
            scenario_file.put(content, key, value, f"--set {key}")
    plant = content["plant"]
    assert isinstance(plant, dict)
    if not isinstance(plant["system"], dict) or plant["system"].get("kind") != kind:
        raise CallerError(f"--set plant.system: the plant is {label}; set its values, one by one")
    system = _validated_settings(plant["system"], label)
    rates = {key: _positive_rate(key, plant[key]) for key in ("rate_hz", "measure_every") if key in plant}
    if (outline := system.outline()) is not None:
        if outline.rate_hz is not None:
            rates = {"rate_hz": float(f"{outline.rate_hz:.12g}")}
        names = _plain_names(outline.states), _plain_names(outline.inputs)
        m = outline.m
        if m is None:
            _, m = _sizes_of_class(system, label, (outline.n, sizes[1]))
        return PlantReference(
            label, settings, system, outline.n, m, names, rates, outline.initial_state,
            _units(outline.states), {plain_name(name): value for name, value in outline.allowed.items()},
        )  # fmt: skip
    if isinstance(system, PythonPlantSettings):
        n, m = _sizes_of_class(system, label, sizes)
        return PlantReference(label, settings, system, n, m, (None, None), rates)
    base = _of_scenario(str(system.scenario), {})
    initial = base.initial_state
    return PlantReference(
        label, settings, system, base.n, base.m, base.names, {**base.rates, **rates}, initial,
        _units(system.states),
    )  # fmt: skip


def _system_table(label: str) -> Table | None:
    """Return the table plant.system that a text names; None if it may be a scenario."""
    file, colon, name = label.rpartition(":")
    for kind in PLANTS.values():
        if (table := kind.named_by(label)) is not None:
            return table
    if label.endswith(".py"):
        classes = _classes(Path(label))
        if not classes:
            raise CallerError(f"{label}: defines no class; a plant has one with derivative(self, t_s, z, u)")
        if len(classes) > 1:
            choices = " or ".join(f"{label}:{each}" for each in classes)
            raise CallerError(f"{label}: which class of it? write {choices}")
        return {"kind": "python", "file": label, "name": classes[0]}
    if colon and file.endswith(".py"):
        return {"kind": "python", "file": file, "name": name}
    if label in PLANTS:
        if label not in _KINDS:
            raise CallerError(f"{label}: names no plant by itself; {_FORMS}")
        return {"kind": label}
    for kind_name in (label.partition(":")[0], Path(label).suffix.removeprefix(".")):
        if missing := missing_extension("noack.plants", kind_name):
            raise CallerError(f"{label}: {missing}")
    return {"kind": "python", "name": label} if colon else None


def _positive_rate(key: str, value: object) -> float:
    if not isinstance(value, int | float) or not value > 0:
        raise CallerError(f"--set plant.{key}: {value!r}; give a positive number")
    return float(value)


def _classes(path: Path) -> list[str]:
    """Return the names of the classes in a Python file.

    Raises:
        CallerError: it cannot be read, or is not Python.
    """
    try:
        statements = ast.parse(path.read_bytes(), path.name).body
    except OSError as error:
        raise CallerError(f"{path}: cannot be read: {why(error)}") from None
    except (SyntaxError, ValueError) as error:
        raise CallerError(f"{path}: {type(error).__name__}: {one_line(error)}") from None
    return [statement.name for statement in statements if isinstance(statement, ast.ClassDef)]


def _validated_settings(table: object, label: str) -> PlantSettings:
    """Return validated settings whose file is found."""
    assert isinstance(table, dict)
    system = toml_file.validated(PLANTS[str(table["kind"])], table, f"{label}: plant.system")
    return with_absolute_path(system, Path.cwd(), "plant.system")


def _of_scenario(label: str, settings: ReadTable) -> PlantReference:
    try:
        path = find_shipped(label, "scenarios")
        content = toml_file.read(path)
    except CallerError as error:
        if Path(label).exists():
            raise
        if shipped := did_you_mean(label, [*PLANTS, *shipped_names("scenarios")]):
            raise CallerError(f"{label}: no such plant; {shipped}") from None
        raise CallerError(f"{error}; {_FORMS}") from None
    for key, value in settings.items():
        scenario_file.put(content, key, value, f"--set {key}")
    if isinstance(model := content.get("model"), dict):  # its gain does not matter, and may be missing
        model["allow_unstable"] = True
        if model.pop("integral", None) is not None:
            model.pop("gain", None)
        if isinstance(B := model.get("B"), list) and B and isinstance(B[0], list):
            model.setdefault("gain", [[0.0] * len(B)] * len(B[0]))
    content.pop("controller", None)  # its states are not the plant's
    resolved = resolve(scenario_file.completed(content, path))
    loop, plant = loop_of(resolved).without_loads, resolved.plant
    return PlantReference(
        label=label,
        settings=settings,
        system=plant.system,
        n=loop.n,
        m=loop.m,
        names=(loop.state_names, loop.input_names),
        rates={"rate_hz": plant.rate_hz, "measure_every": plant.measure_every},
        initial_state=plant.initial_state[: loop.n],
        matrices=(loop.A, loop.B) if resolved.coverage.is_linear else None,
        model_matrices=(loop.A_model, loop.B_model) if resolved.coverage.is_linear else None,
        outputs={output.name: np.array(output.row) for output in loop.outputs},
    )


def _plain_names(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    return names and tuple(map(plain_name, names))


def _units(states: tuple[str, ...] | None) -> tuple[str, ...]:
    return tuple(name_and_unit(state)[1] for state in states or ())


def _sizes_of_class(
    system: PlantSettings, label: str, sizes: tuple[int | None, int | None]
) -> tuple[int, int]:
    """Return the smallest numbers of states and inputs that a user's class accepts."""
    ranges = [range(1, _LARGEST_TRIED_SIZE + 1) if size is None else (size,) for size in sizes]
    refusals: dict[str, tuple[int, int]] = {}
    for n, m in product(*ranges):
        start = PlantStart(np.zeros(n), np.zeros((n, n)), np.zeros((n, m)), STEP_NS)
        try:
            with np.errstate(all="ignore"):
                system.system(start).advance(np.zeros(m), 0, STEP_NS)
        except Exception as error:  # an equation that is tried with too few states
            refusals.setdefault(str(error), (n, m))
        else:
            return n, m
    first, *further_refusals = refusals
    if not further_refusals:
        raise CallerError(first)
    raise CallerError(
        f"{label}: no number of states and inputs up to {_LARGEST_TRIED_SIZE} is accepted at x = 0, u = 0; "
        f"--at and --input give the numbers. With one of each: {first}"
    )
