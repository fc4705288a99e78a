"""A scenario for a plant: a file with comments, whose settings are chosen so that it is certified.

The loop is tried with several limits of consecutive losses, rates and thresholds, and also with a
slower gain if noack chooses the gain. Each trial is certified, which takes some 30 ms. The first
one whose bound of ‖x‖ is below 200 times ‖x(0)‖ is used, else the one with the smallest
bound. If there is none, a norm is chosen for the trial that came closest. x(0) is made smaller if a
nonlinear plant does not return to 0 in a simulation.
"""

import math
import os
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.analysis.certificates import with_linear_plant
from cosim.simulation.virtual_time import simulate_loops
from cosim.studies.new_loop import (
    ALPHA_SHARE,
    BETA_SHARE,
    LOSS_PROBABILITY,
    MANSD,
    SETTLED,
    rounded,
)
from cosim.studies.new_loop.linear_model import LinearModel, eigenvalue_text, vector
from cosim.studies.new_loop.loop_gain import LoopGain, loop_gain
from noack.core.errors import CallerError, MachineError, why
from noack.core.file_access import new_file
from noack.core.linear_systems import Matrix, Vector, norm
from noack.core.number_format import number
from noack.plants.fmu import FmuSettings
from noack.plants.gymnasium import GymnasiumSettings
from noack.plants.linear import LinearSettings
from noack.plants.python_plant import PythonPlantSettings
from noack.scenario.resolution import loop_of, resolve_run, resolved_loops
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed, put, toml_text
from noack.settings.section import ReadTable, Table
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.scenario_certificates import certify, own_plant
from noack.theory.certificates.weight import choose_weight

ALPHA_SHARES = (ALPHA_SHARE, ALPHA_SHARE / 2)
_FLOOR_SHARE = 0.05
_FASTEST_ALPHA_PER_S = 1.0
_RATES_HZ = (1.0, 2.0, 5.0, 10.0, 20.0, 25.0, 50.0, 100.0, 200.0, 250.0, 500.0, 1000.0)
_STEPS_PER_TIME_CONSTANT = 50
_INPUT_WEIGHTS = (1.0, 10.0, 100.0)
_LOOSE = 200.0
_START = 0.1
_SMALLER, _FEWEST = 0.5, 6
_LONGEST_RUN_S = 20.0
Report = Callable[[str], None]


@dataclass(frozen=True)
class NewScenario:
    """A scenario for a plant: its ``text`` as a file, the loaded ``scenario``, what was chosen.

    ``certificate`` is for the scenario's schedule, and of the linear plant. It is None if none was
    found; ``void`` is the reason. ``notes`` are sentences about what was chosen.
    """

    gain: LoopGain
    scenario: Scenario
    text: str
    certificate: ScenarioCertificate | None
    void: str | None
    notes: tuple[str, ...]

    def save(self, path: str | Path) -> None:
        """Write the file; raise CallerError if it exists, MachineError if it cannot be written."""
        if Path(path).exists():
            raise CallerError(f"{path}: exists; give another name, or remove it first")
        try:
            with new_file(Path(path), make_folder=False) as file:
                file.write(self.text.encode())
        except OSError as error:
            raise MachineError(f"{path}: cannot be written: {why(error)}") from None

    def to_json(self) -> Table:
        """Return the document of ``noack new --json``."""
        return self.gain.to_json() | {
            "toml": self.text,
            "scenario": self.scenario.model_dump(mode="json"),
            "certificate": self.certificate and self.certificate.to_json(),
            "void": self.void,
            "notes": self.notes,
        }

    def __repr__(self) -> str:
        return self.text


@dataclass(frozen=True)
class _Trial:
    """A loop with settings that are tried together."""

    gain: LoopGain
    rate_hz: float
    mansd: int
    alpha_per_s: float
    x0: Vector
    weight: Matrix | None = None

    @property
    def beta(self) -> float:
        """β."""
        start = self.x0 if self.weight is None else self.weight @ self.x0
        return rounded(BETA_SHARE * norm(start) or BETA_SHARE)


def new_scenario(
    plant: LinearModel | LoopGain,
    path: Path,
    *,
    initial_state: Sequence[float] | None = None,
    settings: ReadTable | None = None,
    report: Report = lambda text: None,
) -> NewScenario:
    """Choose a scenario for a plant.

    Args:
        plant: the plant's linear model, for which K is chosen, or the model with K.
        path: the file that it will have; file names in it are relative to its folder.
        initial_state: x(0); by default chosen.
        settings: values by the keys of a scenario that are not to be chosen.
        report: called with what is being done.

    Raises:
        CallerError: the plant does not rest at x = 0, u = 0, or a value is wrong.
    """
    model = plant.model if isinstance(plant, LoopGain) else plant
    _require_rest(model)
    fixed = {
        key: one for key, one in (settings or {}).items() if not key.startswith("plant.system")
    }
    x0 = _initial_state(model, fixed.pop("plant.initial_state", initial_state))
    build = _Builder(model, path, fixed)
    best, certificate, void = build.search(list(_trials(plant, x0)), report)
    shrunk = 0
    given = initial_state is not None or "plant.initial_state" in (settings or {})
    report("simulating")
    while not (settles := build.settles(best)) and not given and shrunk < _FEWEST:
        shrunk += 1
        best = replace(best, x0=best.x0 * _SMALLER)
    if shrunk and settles and certificate is not None:
        certificate, void = build.certified(best)
    notes = tuple(_notes(best, certificate, void, settles, build.is_linear))
    content = build.content(best)
    text = _commented(content, notes, best)
    return NewScenario(best.gain, completed(content, path), text, certificate, void, notes)


def _require_rest(model: LinearModel) -> None:
    moved = model.at.any() or model.input.any()
    if moved and not isinstance(model.plant.system, FmuSettings | LinearSettings):
        raise CallerError(
            f"{model.plant.label}: a scenario needs x and u as deviations from its operating "
            "point; let the plant subtract this point, and linearise it at 0"
        )
    if not model.rests:
        raise CallerError(
            f"{model.plant.label}: does not rest at the point: ẋ = "
            f"({', '.join(f'{one:.4g}' for one in model.drift)}); a scenario needs an equilibrium"
        )


def _initial_state(model: LinearModel, given: object) -> Vector:
    """Return x(0): as given, the plant's own, or 0.1 for each state that is no other's rate."""
    n = len(model.A)
    if given is not None:
        return vector("x0", given, n, "states")
    if model.plant.initial_state is not None:
        return np.array(model.plant.initial_state)
    one = np.eye(n)
    is_rate = [any((model.A[i] == one[j]).all() for i in range(n) if i != j) for j in range(n)]
    x0 = np.where(is_rate, 0.0, _START)
    return x0 if x0.any() else np.full(n, _START)


def _trials(plant: LinearModel | LoopGain, x0: Vector) -> Iterator[_Trial]:
    """Yield what is tried, the preferred settings first."""
    if isinstance(plant, LoopGain):
        gains = [plant]
    else:
        gains = [loop_gain(plant, r=weight) for weight in _INPUT_WEIGHTS]
    for gain in gains:
        system, rates = gain.model.plant.system, gain.model.plant.rates
        fastest = max(
            (abs(one) for one in gain.eigenvalues if abs(one) < _RATES_HZ[-1]), default=1.0
        )
        wanted = _STEPS_PER_TIME_CONSTANT * fastest
        base = next((rate for rate in _RATES_HZ if rate >= wanted), _RATES_HZ[-2])
        base = rates.get("rate_hz", min(base, _RATES_HZ[-2]))
        is_fixed = isinstance(system, GymnasiumSettings)
        for rate in (base,) if is_fixed else (base, 2 * base):
            for mansd in range(MANSD, 0, -1):
                for share in ALPHA_SHARES:
                    alpha = rounded(min(share * gain.decay_per_s, _FASTEST_ALPHA_PER_S))
                    yield _Trial(gain, rate, mansd, alpha, x0)


class _Builder:
    """Builds, certifies and simulates the scenarios of trials."""

    def __init__(self, model: LinearModel, path: Path, fixed: ReadTable) -> None:
        self._model, self._path, self._fixed = model, path, fixed
        self.is_linear = isinstance(model.plant.system, LinearSettings)

    def content(self, trial: _Trial) -> Table:
        """Return the content of the scenario file."""
        model, reference = trial.gain.model, trial.gain.model.plant
        states, inputs = reference.names
        alpha = trial.alpha_per_s
        horizon_s = rounded(math.log(1 / SETTLED) / alpha)
        speed = max(1.0, float(round(horizon_s / _LONGEST_RUN_S)))
        section: Table = {
            "A": model.A.tolist(),
            "B": model.B.tolist(),
            "gain": trial.gain.K.tolist(),
        }
        section |= {} if states is None else {"state_names": list(states)}
        section |= {} if inputs is None else {"input_names": list(inputs)}
        plant: Table = {} if self.is_linear else {"system": self._system()}
        plant |= {"initial_state": trial.x0.tolist(), "rate_hz": trial.rate_hz}
        if (every := reference.rates.get("measure_every", 1)) != 1:
            plant["measure_every"] = int(every)
        trigger: Table = {
            "policy": "decaying", "beta": trial.beta, "alpha_per_s": alpha,
            "floor": rounded(_FLOOR_SHARE * trial.beta),
        }  # fmt: skip
        if trial.weight is not None:
            trigger["weight"] = [[float(f"{v:.6g}") for v in row] for row in trial.weight]
        content: Table = {
            "name": "".join(c if c.isalnum() or c in "_-" else "_" for c in self._path.stem),
            "description": f"{reference.label} over a network that loses half of the updates.",
            "horizon_s": horizon_s,
            **({"speed": speed} if speed > 1 else {}),
            "model": section,
            "plant": plant,
            "controller": {"rate_hz": trial.rate_hz},
            "trigger": trigger,
            "network": {
                "mansd": trial.mansd,
                "loss": {"model": "bernoulli", "probability": LOSS_PROBABILITY},
            },
            "seeds": {"loss": 1},
        }
        for key, value in self._fixed.items():
            put(content, key, value, f"--set {key}")
        return content

    def _system(self) -> Table:
        """Return the table plant.system, with a file's name relative to the scenario's folder."""
        system, model = self._model.plant.system, self._model
        table = system.content()
        if isinstance(system, FmuSettings | PythonPlantSettings) and system.file is not None:
            folder = self._path.absolute().parent
            table["file"] = os.path.relpath(system.file, folder)
            table.pop("sha256", None)
        if isinstance(system, FmuSettings):
            for key, value in (("operating_state", model.at), ("operating_input", model.input)):
                if value.any():
                    own = getattr(system, key) or np.zeros_like(value)
                    table[key] = (value + np.array(own)).tolist()
        return {key: one for key, one in table.items() if one not in ({}, [])}

    def certified(self, trial: _Trial) -> tuple[ScenarioCertificate | None, str | None]:
        """Return the certificate of a trial's linear plant, or None and the reason."""
        resolved = self._of_linear_plant(trial)
        try:
            resolved.coverage.require_certifiable()
            late = resolved.certificate.late_periods
            found = certify(resolved, nominal_conditions(resolved, late))
        except CallerError as error:
            return None, str(error)
        return (None, found.void) if found.constants is None else (found, None)

    def _of_linear_plant(self, trial: _Trial) -> Scenario:
        loops = resolved_loops(completed(self.content(trial), self._path))
        return with_linear_plant(loops[0])

    def search(
        self, trials: Sequence[_Trial], report: Report
    ) -> tuple[_Trial, ScenarioCertificate | None, str | None]:
        """Return the trial that is used, and its certificate or the reason why there is none."""
        certified: list[tuple[float, _Trial, ScenarioCertificate]] = []
        reasons: dict[str, str | None] = {}
        for place, trial in enumerate(trials):
            report(f"certifying: {place + 1} of {len(trials)}")
            if (content := str(self.content(trial))) in reasons:  # the given settings exclude it
                continue
            found, reasons[content] = self.certified(trial)
            if found is None or found.constants is None:
                continue
            ratio = found.constants.state / (norm(trial.x0) or 1.0)
            certified.append((ratio, trial, found))
            if ratio <= _LOOSE:
                break
        if certified:
            _, trial, found = min(certified, key=lambda one: one[0])
            return trial, found, None
        report("choosing a norm")
        for trial in self._closest(trials):
            weighted = self._weighted(trial)
            found, _ = (None, None) if weighted is None else self.certified(weighted)
            if found is not None and weighted is not None:
                return weighted, found, None
        return trials[0], None, next(iter(reasons.values()))

    def _closest(self, trials: Sequence[_Trial]) -> list[_Trial]:
        """Return the trials with the smallest loop gains, at most one for each gain K."""
        if "trigger.weight" in self._fixed:
            return []
        closest: dict[int, tuple[float, _Trial]] = {}
        for trial in trials:
            resolved = self._of_linear_plant(trial)
            conditions = nominal_conditions(resolved, resolved.certificate.late_periods)
            gain = own_plant(resolved).loop_gain(conditions)
            key = id(trial.gain)
            if math.isfinite(gain) and gain < closest.get(key, (math.inf,))[0]:
                closest[key] = gain, trial
        return [trial for _, trial in sorted(closest.values(), key=lambda one: one[0])]

    def _weighted(self, trial: _Trial) -> _Trial | None:
        resolved = self._of_linear_plant(trial)
        late = resolved.certificate.late_periods
        try:
            weight = choose_weight(
                loop_of(resolved), trial.beta, trial.alpha_per_s, nominal_conditions(resolved, late)
            )
        except (NotDecayingError, np.linalg.LinAlgError):
            return None
        return replace(trial, weight=weight)

    def settles(self, trial: _Trial) -> bool:
        """Whether ‖x‖ ends below a tenth of its maximum, in virtual time."""
        scenario = resolve_run(completed(self.content(trial), self._path))
        states = simulate_loops(scenario).loop().columns("plant_step", "x")["x"]
        sizes = np.linalg.norm(states, axis=1)
        return bool(np.isfinite(sizes).all() and sizes[-1] <= 0.1 * max(sizes.max(), 1e-300))


def _notes(
    trial: _Trial,
    certificate: ScenarioCertificate | None,
    void: str | None,
    settles: bool,
    is_linear: bool,
) -> Iterator[str]:
    """Yield what was chosen and found, a sentence each."""
    model, gain = trial.gain.model, trial.gain
    yield f"K: {gain.method}; decay rate of Â + B̂K: {gain.decay_per_s:.3g} /s."
    plant = "the plant" if is_linear else "the linear plant ẋ = Âx + B̂u"
    if certificate is None or certificate.constants is None:
        yield (
            f"No certificate was found for {plant}: {void}. Faster rates, a slower gain (a larger "
            "--r) or smaller network.mansd may give one."
        )
    else:
        bound = envelope_formula("‖x‖", certificate, "state").format(certificate.constants.state)
        norm_text = (
            "" if trial.weight is None else " The trigger has a norm that was chosen for it."
        )
        yield f"Certified for {plant}, for every pattern of losses: {bound}.{norm_text}"
    if not is_linear:
        errors = "; ".join(
            f"{number(float(found.max()), 2)} within ±{within:g}" for within, found in model.errors
        )
        yield (
            "The plant is not linear, so no certificate covers it: a run of it checks only what "
            f"holds for every plant. Largest relative error of the linear model: {errors}."
        )
    yield (
        f"Simulated with x(0) = ({', '.join(f'{one:.3g}' for one in trial.x0)}): "
        + ("the loop returns to 0." if settles else "the loop does not return to 0.")
    )


_COMMENTS: Mapping[str, str] = {
    "horizon_s": "Length of the run in simulated time: e^(−alpha_per_s t) falls to a hundredth.",
    "speed": "Simulated time per wall time of a live run.",
    "model": "What sensor and controller know of the plant: ẋ = A x + B u, per second.",
    "model.gain": "u = gain x_c, with A + B gain stable (LQR of other programs: the sign is −).",
    "plant": "The true plant.",
    "plant.initial_state": "x(0), one number per state.",
    "plant.rate_hz": "Steps of the plant and measurements per second of simulated time.",
    "controller.rate_hz": "Inputs per second of simulated time.",
    "trigger": "The sensor transmits when the error of its model exceeds the threshold "
    "max(beta e^(−alpha_per_s t), floor).",
    "trigger.beta": "The first threshold: a tenth of the norm of x(0). Larger: fewer "
    "transmissions, larger errors.",
    "trigger.alpha_per_s": "Must be below the decay rate of A + B gain.",
    "trigger.floor": "The last threshold; 0: x converges to 0, with ever smaller thresholds.",
    "trigger.weight": "W of the norm ‖W e‖ in which the error is measured; a certificate needs it.",
    "network.mansd": "Maximum consecutive losses, M − 1. The network delivers the next packet.",
    "network.loss": "Losses before this limit is applied: half of the packets.",
    "seeds": "Another number: other losses.",
}


def _commented(content: ReadTable, notes: Sequence[str], trial: _Trial) -> str:
    """Return the file: the content with comments."""
    comments = dict(_COMMENTS)
    comments["trigger.alpha_per_s"] += f" That is {trial.gain.decay_per_s:.4g} /s here."
    eigenvalues = eigenvalue_text(trial.gain.eigenvalues)
    comments["model.gain"] += f" {trial.gain.method}; eigenvalues {eigenvalues} /s."
    lines = [f"# A scenario for {trial.gain.model.plant.label}, written by `noack new`."]
    lines += [line for note in notes for line in _comment(note)]
    lines += _section("", content, comments)
    return "\n".join(lines) + "\n"


def _section(name: str, table: ReadTable, comments: Mapping[str, str]) -> list[str]:
    lines = _comment(comments.get(name, ""))
    lines = ["", *lines, f"[{name}]"] if name else lines
    inner: list[str] = []
    for key, value in table.items():
        path = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            inner += _section(path, value, comments)
        else:
            lines += _comment(comments.get(path, "")) + toml_text({key: value}).splitlines()
    return lines + inner


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="# ")
