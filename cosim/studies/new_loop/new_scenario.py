"""A scenario for a plant: a file with comments, whose settings are chosen so that it is certified.

x(0) is made smaller if a nonlinear plant does not return to 0 in a simulation.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from cosim.record.run_directory import refuse_among_results
from cosim.studies.new_loop.choices import Choices
from cosim.studies.new_loop.choose import best_trial, certificate_of, returns_to_rest, with_threshold
from cosim.studies.new_loop.linear_model import (
    LinearModel,
    LoopGain,
    beside_steps,
    gain,
    model_or_gain,
    parse_vector,
)
from cosim.studies.new_loop.notes import bound_notes, guarantee_text, input_notes, loop_notes
from cosim.studies.new_loop.scenario_text import file_text
from cosim.studies.new_loop.trial_scenario import POLICY, content_of, scenario_of
from cosim.studies.new_loop.trials import (
    DEFAULT_START,
    LoopTrial,
    input_weights,
    largest_sizes,
    list_trials,
    state_weights,
)
from netem.core.errors import CallerError, MachineError, why
from netem.core.file_access import new_file
from netem.core.number_checks import real_number
from netem.core.settings_section import ReadTable, Table
from noack.core.linear_systems import Vector, norm
from noack.scenario.given_settings import given_settings
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import network_of, with_file_names
from noack.theory.certificates.certified_bounds import ScenarioCertificate


@dataclass(frozen=True)
class NewScenario:
    """A scenario for a plant: its ``text`` as a file, the loaded ``scenario``, what was chosen.

    ``certificate`` is for the scenario's schedule and the linear plant; it is None if none was
    found. ``guarantee`` is the sentence of ``noack certify`` about the plant itself; ``notes`` are
    sentences about what was chosen and found.
    """

    gain: LoopGain
    scenario: Scenario
    text: str
    certificate: ScenarioCertificate | None
    guarantee: str
    notes: tuple[str, ...]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the file, which ends in .toml; raise NoackError if it exists, or cannot be written."""
        require_new_file(Path(path))
        try:
            with new_file(Path(path), make_folder=False) as file:
                file.write(self.text.encode())
        except (OSError, ValueError) as error:
            raise MachineError(f"{path}: cannot be written: {why(error)}") from None

    def to_json(self) -> Table:
        """Return the document of ``noack new --json``."""
        certificate = self.certificate and self.certificate.to_json()
        return self.gain.to_json() | {
            "toml": self.text,
            "guarantee": self.guarantee,
            "notes": self.notes,
            "certificate": certificate,
        }

    def __repr__(self) -> str:
        return self.text


def require_new_file(path: Path) -> None:
    """Raise CallerError unless a new scenario can be written to a file of this name."""
    if path.suffix != ".toml":
        raise CallerError(f"{path}: the name of a scenario file ends in .toml")
    if path.exists():
        raise CallerError(f"{path}: exists; give another name, or remove it first")
    if not path.parent.is_dir():
        raise CallerError(f"{path}: there is no folder {path.parent}")
    refuse_among_results(path)


def new(
    plant: str | PathLike[str] | LinearModel | LoopGain,
    path: str | PathLike[str] = "new.toml",
    *,
    initial_state: Sequence[float] | None = None,
    allowed: Mapping[str, float] | None = None,
    settings: ReadTable | None = None,
    network: str | PathLike[str] | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> NewScenario:
    """Choose a complete scenario for a plant; its ``save`` writes the file.

    >>> import noack
    >>> chosen = noack.new(noack.gain("double_integrator"), settings={"network.mansd": 1})
    >>> chosen.scenario.network.mansd, chosen.scenario.trigger.policy
    (1, 'decaying')

    Args:
        plant: a gain with its model; a model or a plant, for which K is chosen; or the file of one.
        path: the file that the scenario will have; file names in it are relative to its folder.
        initial_state: x(0), n entries; by default chosen.
        allowed: allowed errors by the names of states; by default those that the plant states. The
            threshold is chosen for them.
        settings: values by the keys of a scenario that are not to be chosen.
        network: a file whose table ``[network]`` is used, before the settings.
        report: called with what is being done.

    Raises:
        NoackError: the plant does not rest at x = 0, u = 0, or a value is wrong.
    """
    values = dict(given_settings(settings))
    if (policy := values.get("trigger.policy", POLICY)) != POLICY:
        raise CallerError(
            f'trigger.policy = {policy}: noack new chooses a threshold, of policy "{POLICY}"; give another '
            f"rule as a whole table: --set 'trigger={{policy=\"{policy}\", ...}}'"
        )
    if network is not None:
        values = {"network": _network(Path(network), Path(path)), **values}
    plant_model = plant if isinstance(plant, LinearModel | LoopGain) else model_or_gain(plant, values)
    fixed = {key: value for key, value in values.items() if not key.startswith("plant.system")}
    fixed_state = fixed.pop("plant.initial_state", initial_state)
    model = plant_model.model if isinstance(plant_model, LoopGain) else plant_model
    _require_rest(model)
    errors = _allowed(model, allowed)
    x0 = _initial_state(model, fixed_state)
    if plant_model is model:
        first = gain(model, q=state_weights(model, errors), r=input_weights(model, 1.0))
        plant_model = model = beside_steps(model, largest_sizes(first, x0))
    choices = Choices(model, Path(path), fixed, errors)
    best = best_trial(choices, [*list_trials(plant_model, x0, errors)], report)
    report("simulating")
    is_free = fixed_state is None and model.plant.initial_state is None
    best, returns = _with_smaller_start(choices, best) if is_free else (best, returns_to_rest(choices, best))
    simulated = best
    best, results = with_threshold(choices, best, report)
    if content_of(choices, best) != content_of(choices, simulated):  # by another threshold, fewer losses
        report("simulating")
        returns = returns_to_rest(choices, best)
    guarantee, of_plant = guarantee_text(results), results.guaranteed is not None
    certificate = certificate_of(choices, best)
    notes = [*bound_notes(results, best.x0), *loop_notes(best, certificate, returns, of_plant=of_plant)]
    if not isinstance(plant_model, LoopGain):
        notes += input_notes(best)
    text = file_text(content_of(choices, best), (f"{guarantee}.", *notes), best, fixed)
    found_certificate = certificate if certificate.exists else None
    return NewScenario(
        best.gain, scenario_of(choices, best), text, found_certificate, guarantee, tuple(notes)
    )


def _with_smaller_start(choices: Choices, trial: LoopTrial) -> tuple[LoopTrial, bool]:
    """Halve x(0), at most five times, until the loop returns to rest; return also whether it does."""
    returns = returns_to_rest(choices, trial)
    for _ in range(5):
        if returns:
            break
        trial = replace(trial, x0=trial.x0 / 2)
        returns = returns_to_rest(choices, trial)
    return trial, returns


def _allowed(model: LinearModel, given: Mapping[str, float] | None) -> Mapping[str, float]:
    """Return the allowed errors by the names of states: as given, or as the plant states them."""
    names = model.plant.state_names
    for name, value in (given or {}).items():
        if name not in names:
            raise CallerError(f"--allow {name}: no such state; the states are {', '.join(names)}")
        real_number(f"--allow {name}", value, above=0.0)
    stated = {name: float(value) for name, value in model.plant.allowed.items()}  # type: ignore[arg-type]
    return stated if given is None else given


def _network(source: Path, path: Path) -> Table:
    """Return the network of a file; names of files become relative to the folder of another one."""
    folder = path.absolute().parent
    return with_file_names(network_of(source), lambda name: os.path.relpath(name, folder))


def _require_rest(model: LinearModel) -> None:
    label, is_moved = model.plant.label, model.at.any() or model.input.any()
    if is_moved and not model.plant.system.has_operating_point:
        raise CallerError(
            f"{label}: a scenario needs x and u as deviations from its operating point; let the "
            "plant subtract this point, and linearise it at 0"
        )
    if not model.rests:
        drift = ", ".join(f"{entry:.4g}" for entry in model.drift)
        if _jumps_at_rest(model):
            raise CallerError(
                f"{label}: its equations jump at rest, where ẋ is ({drift}); dry friction of size f, such as "
                "math.copysign(f, v), is f * np.tanh(v / w) with a small w"
            )
        raise CallerError(
            f"{label}: a scenario needs an equilibrium; at the point ẋ is ({drift}). "
            "`noack linearise` shows where the linear model rests"
        )


def _jumps_at_rest(model: LinearModel) -> bool:
    """Return whether ẋ jumps where a state passes the point, by more than half of ẋ there."""
    rates = getattr(model.plant.system_at(model.at), "rates", None)
    for off in np.eye(model.plant.n) * 1e-12 * max(1.0, norm(model.at)):
        ends = [None if rates is None else rates(model.at + moved, model.input) for moved in (off, -off)]
        if ends[0] is None or ends[1] is None:
            return False
        if norm(ends[0] - ends[1]) > norm(model.drift) / 2:
            return True
    return False


def _initial_state(model: LinearModel, fixed_state: object) -> Vector:
    """Return x(0): as given, the plant's own, or 0.1 for each state that is no other's rate."""
    n, unit = model.plant.n, np.eye(model.plant.n)
    if fixed_state is not None or model.plant.initial_state is not None:
        fixed_state = model.plant.initial_state if fixed_state is None else fixed_state
        return parse_vector("x0", fixed_state, n, "states")
    is_rate = [any((model.A[i] == unit[j]).all() for i in range(n) if i != j) for j in range(n)]
    return np.where(is_rate, 0.0, DEFAULT_START) if not all(is_rate) else np.full(n, DEFAULT_START)
