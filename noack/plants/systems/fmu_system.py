"""A Functional Mock-up Unit: another tool's model, run by FMPy (FMI 2 and 3, co-simulation).

As the standard requires, its start values are set and it is initialised at t = 0. At each step of
the plant, its inputs are set, one ``doStep`` is made, and its variables are read. The FMU is native
code and runs in this process. Its printed output is discarded; the last error in its log is kept.
"""

import contextlib
import difflib
import io
import os
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.plants.fmu import FmuSettings
from noack.plants.systems.native_code import quiet, temporary_folder
from noack.plants.systems.plant_system import SystemFailedError
from noack.settings.user_files import unchanged

_WARNING, _DISCARD, _ERROR, _FATAL = 1, 2, 3, 4
"""Status codes of FMI."""
_REAL = {"Real", "Float64", "Float32"}
_VALUES: Mapping[str, tuple[tuple[type, ...], str]] = {
    **dict.fromkeys(_REAL, ((int, float), "a number")),
    "Boolean": ((bool,), "true or false"),
    "String": ((str,), "a text"),
}
"""Python types of a variable's value, by its FMI type; all others are whole numbers."""
Refusal = Callable[[Any], str | None]
"""Returns why a variable is unsuitable; None if it is suitable."""

_ALIKE = 1e-6
"""Largest relative difference between x(0) of the scenario and x(0) of the FMU."""
_LONGEST = 300
"""Largest length of a quoted text, in characters."""


class FmuSystem:
    """An instance of an FMU, initialised at x(0).

    Raises:
        CallerError: FMPy is missing, the FMU does not match the settings, or it cannot be started.
    """

    def __init__(self, settings: FmuSettings, x0: Vector) -> None:
        settings.require_installed()
        path = unchanged(settings, "plant.system")
        self._place = f'plant.system.file = "{path.name}"'
        self._operating_state = np.array(settings.operating_state or np.zeros_like(x0))
        m = len(settings.input_variables)
        self._operating_input = np.array(settings.operating_input or np.zeros(m))
        self._log = _Log()
        end = contextlib.ExitStack()
        weakref.finalize(self, end.close)  # when the object is deleted, or the process ends
        try:
            description = self._described(path)
            self.about = _about(description)
            self._instance = self._loaded(path, end, description)
            self._start(settings, x0, description)
        except CallerError:
            end.close()
            raise
        except Exception as error:  # FMPy has no exception class of its own for most errors
            end.close()
            self._wrong(f"cannot be started: {self._log.why(error)}")

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Set the inputs, make one communication step, read the variables."""
        try:
            with quiet():
                self._inputs.set(u + self._operating_input)
                done = self._instance.fmu.doStep(t_ns * 1e-9, dt_ns * 1e-9)
                if done is not None and done[1]:
                    raise RuntimeError("it requests the end of the simulation")
                self._read()
        except Exception as error:  # as above
            self._instance.status = getattr(error, "status", _ERROR)
            raise SystemFailedError(f"{self._place}: {self._log.why(error)}") from None

    def _read(self) -> None:
        self.x = self._states.get() - self._operating_state
        self.z = self._recorded.get()

    def _wrong(self, message: str) -> NoReturn:
        raise CallerError(f"{self._place}: {message}")

    def _described(self, path: Path) -> Any:
        """The FMU's model description."""
        fmpy = _fmpy()
        try:
            with path.open("rb") as file:  # FMPy does not close a file that it cannot read
                description = fmpy.read_model_description(file, validate=False)
        except Exception as error:  # a file that is not an FMU can raise any error
            self._wrong(f"is no FMU of FMI 2 or 3, or a damaged one: {_short(error)}")
        if description.fmiVersion.startswith("1."):
            self._wrong(f"is of FMI {description.fmiVersion}; FMI 2 and 3 are supported")
        if description.coSimulation is None:
            self._wrong("is not for co-simulation; export it as a co-simulation FMU")
        return description

    def _loaded(self, path: Path, end: contextlib.ExitStack, description: Any) -> "_Instance":
        """Unpack and instantiate the FMU."""
        fmpy, folder = _fmpy(), end.enter_context(temporary_folder())
        fmpy.extract(str(path), str(folder))
        self._require_binary(folder, description)
        before = Path.cwd()
        try:
            with quiet(), contextlib.redirect_stdout(io.StringIO()):
                fmu = fmpy.instantiate_fmu(
                    str(folder), description, fmi_type="CoSimulation", logger=self._log.take
                )
        finally:
            os.chdir(before)  # if loading fails, FMPy does not change back
        instance = _Instance(fmu)
        end.callback(instance.release)
        return instance

    def _require_binary(self, folder: Path, description: Any) -> None:
        fmpy = _fmpy()
        modern = description.fmiVersion.startswith("3.")
        platform = fmpy.platform_tuple if modern else fmpy.platform
        name = description.coSimulation.modelIdentifier + fmpy.sharedLibraryExtension
        if (folder / "binaries" / platform / name).is_file():
            return
        there = sorted(one.name for one in (folder / "binaries").glob("*") if one.is_dir())
        has = f"binaries for {', '.join(there)} only" if there else "no binaries"
        sources = (folder / "sources").is_dir()
        hint = "; it has sources, which `fmpy compile` can compile" if sources else ""
        self._wrong(f"has {has}; this machine needs {platform}/{name}{hint}")

    def _start(self, settings: FmuSettings, x0: Vector, description: Any) -> None:
        """Set the start values and initialise the FMU."""
        fmu, variables = self._instance.fmu, _Variables(description)

        def port(key: str, names: Sequence[str], refusal: Refusal = lambda one: None) -> _Port:
            return _Port(fmu, variables.real(key, names, refusal))

        self._states = port("state_variables", settings.state_variables, _not_readable)
        self._inputs = port("input_variables", settings.input_variables, _not_an_input)
        self._recorded = port("on_record", settings.on_record)
        initial = settings.initial_variables
        if initial is None:
            initial = settings.state_variables
        start = port("initial_variables", initial, _not_initial)
        parameters = [variables.parameter(*entry) for entry in settings.parameters.items()]
        with quiet():
            if description.fmiVersion == "2.0":
                fmu.setupExperiment(startTime=0.0)
            for variable, value in parameters:
                _set(fmu, variable.type, [variable.valueReference], [value])
            if initial:
                start.set(x0 + self._operating_state)
            fmu.enterInitializationMode()
            self._inputs.set(self._operating_input)
            fmu.exitInitializationMode()
            self._instance.started = True
            self._read()
        scale = np.abs(x0) + np.abs(self._operating_state) + 1.0
        if not np.all(np.abs(self.x - x0) <= _ALIKE * scale):
            raise CallerError(
                f"plant.initial_state: it is {x0.tolist()}, but the FMU begins at "
                f"{self.x.tolist()}; name in plant.system.initial_variables the variables to set"
            )


class _Instance:
    """An instance of an FMU, and its state by the standard."""

    def __init__(self, fmu: Any) -> None:
        self.fmu = fmu
        self.started = False
        self.status = 0

    def release(self) -> None:
        """Terminate and free the instance, as far as its status permits."""
        if self.status >= _FATAL:
            return
        with quiet():
            if self.started and self.status <= _WARNING:
                with contextlib.suppress(Exception):
                    self.fmu.terminate()
            with contextlib.suppress(Exception):
                self.fmu.freeInstance()


class _Log:
    """The last message of an FMU that is more severe than a warning."""

    def __init__(self) -> None:
        self._last = ""

    def take(self, *arguments: Any) -> None:
        """Keep a message; FMI 2: (environment, name, status, category, message), FMI 3: no name."""
        status, message = arguments[-3], arguments[-1]
        if status > _WARNING and message:
            self._last = _short(message.decode(errors="replace"))

    def why(self, error: Exception) -> str:
        """Return an error's text, with the FMU's last message."""
        return f"{_short(error)} ({self._last})" if self._last else _short(error)


class _Variables:
    """The variables of an FMU, with checks of their properties.

    If a variable is missing or unsuitable, every method raises a CallerError of one line.
    """

    def __init__(self, description: Any) -> None:
        self._known: Mapping[str, Any] = {one.name: one for one in description.modelVariables}

    def real(self, key: str, names: Sequence[str], refusal: Refusal) -> list[Any]:
        """Return real scalars that are not refused."""
        found = [self._named(key, name) for name in names]
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise CallerError(f'plant.system.{key}: "{twice}" is named twice')
        for one in found:
            if why := _not_a_real_scalar(one) or refusal(one):
                _refuse(key, one, why)
        return found

    def parameter(self, name: str, value: object) -> tuple[Any, Any]:
        """Return a variable and its start value."""
        one = self._named("parameters", name)
        kinds, needed = _VALUES.get(one.type, ((int,), "a whole number"))
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            _refuse("parameters", one, f"is of type {one.type}; give {needed}, not {value!r}")
        if one.causality == "input":
            _refuse("parameters", one, "is an input; its value at rest is operating_input")
        if why := _not_settable(one):
            _refuse("parameters", one, why)
        return one, value

    def _named(self, key: str, name: str) -> Any:
        if name in self._known:
            return self._known[name]
        close = difflib.get_close_matches(name, self._known, n=1)
        some = ", ".join(list(self._known)[:8])
        hint = f"did you mean {close[0]}?" if close else f"it has {some}"
        raise CallerError(f'plant.system.{key}: the FMU has no variable "{name}"; {hint}')


def _refuse(key: str, variable: Any, why: str) -> NoReturn:
    raise CallerError(f'plant.system.{key}: the FMU\'s "{variable.name}" {why}')


class _Port:
    """Real variables of an instance, read or set together."""

    def __init__(self, fmu: Any, variables: Sequence[Any]) -> None:
        self._fmu, self._size = fmu, len(variables)
        places: dict[str, tuple[list[int], list[int]]] = {}
        for place, variable in enumerate(variables):
            at, references = places.setdefault(variable.type, ([], []))
            at.append(place)
            references.append(variable.valueReference)
        self._places = [(kind, at, references) for kind, (at, references) in places.items()]

    def get(self) -> Vector:
        """Return the variables' values."""
        values = np.empty(self._size)
        for kind, at, references in self._places:
            values[at] = getattr(self._fmu, f"get{kind}")(references)
        return values

    def set(self, values: Vector) -> None:
        """Set the variables to values."""
        for kind, at, references in self._places:
            _set(self._fmu, kind, references, values[at].tolist())


def _set(fmu: Any, kind: str, references: Sequence[int], values: Sequence[Any]) -> None:
    if kind == "Enumeration":
        kind = "Int64" if hasattr(fmu, "setInt64") else "Integer"
    getattr(fmu, f"set{kind}")(references, values)


def _not_a_real_scalar(one: Any) -> str | None:
    if one.type not in _REAL:
        return f"is of type {one.type}; real numbers are needed"
    return "is an array; name scalar variables" if one.dimensions else None


def _not_readable(one: Any) -> str | None:
    readable = one.causality in ("output", "local")
    return None if readable else f"is neither output nor local, but {one.causality}"


def _not_an_input(one: Any) -> str | None:
    return None if one.causality == "input" else f"is no input, but {one.causality}"


def _not_settable(one: Any) -> str | None:
    """Refuse a variable that cannot be set before the initialisation."""
    from fmpy.simulation import settable_in_instantiated

    if settable_in_instantiated(one):
        return None
    return "cannot be set at the start"


def _not_initial(one: Any) -> str | None:
    """Refuse a variable to which x(0) cannot be written."""
    why = _not_settable(one)
    return why and f"{why}; name variables whose initial is exact or approx, or none: []"


def _about(description: Any) -> str:
    """Describe an FMU in one line."""
    tool = description.generationTool or "a tool that it does not name"
    needs = "; it needs that tool to run" if description.coSimulation.needsExecutionTool else ""
    return f"FMU {description.modelName}, FMI {description.fmiVersion}, by {tool}{needs}"


def _fmpy() -> Any:
    with contextlib.redirect_stdout(io.StringIO()):  # the import prints warnings about the platform
        import fmpy
    return fmpy


def _short(what: object) -> str:
    text = " ".join(str(what).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
