"""A scenario for a plant: a file with comments, whose settings are chosen so that it is certified.

With allowed errors, errors of states count in the trigger's norm by how large the states become. If the
plant has friction, its model is the one beside the friction's step, and the gain is stiff enough for the
friction to take a small share of the allowed errors; the first loop of which bounds are proven is used.

Other loops are tried with several limits of consecutive losses, rates and thresholds, and also with
slower gains if the gain is not given. Each trial is certified without a search, in seconds. The
first one whose bound of ‖x‖ is below 200 times ‖x(0)‖ is used, else the one with the smallest bound. If
there is none, the first one is tried with a norm that counts errors by what they do to the input. x(0) is
made smaller if a nonlinear plant does not return to 0 in a simulation.
"""

import math
import os
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from cosim.analysis.certificates import Certificates, certificates_of
from cosim.analysis.claims.run_certificates import RUN_WORK
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.output.guarantee_sentence import guarantee_sentence, is_within_allowed
from cosim.output.run_verdict import SETTLED_SHARE
from cosim.record.run_directory import refuse_among_results
from cosim.simulation.virtual_time import simulate_loops
from cosim.studies.new_loop import (
    ALPHA_SHARE,
    BETA_SHARE,
    DEFAULT_LOSS_PROBABILITY,
    DEFAULT_MANSD,
    HORIZON_DECAY,
)
from cosim.studies.new_loop.linear_model import (
    LinearModel,
    LoopGain,
    beside_steps,
    eigenvalue_text,
    gain,
    model_or_gain,
    parse_vector,
)
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, MachineError, why
from netem.core.file_access import new_file
from netem.core.number_checks import real_number
from netem.core.number_format import to_digits
from netem.core.settings_section import ReadTable, Table
from noack.core.linear_systems import Matrix, Vector, discretise, norm
from noack.plants.linear import LinearSettings
from noack.scenario.given_settings import given_settings
from noack.scenario.resolution import resolve, resolve_run
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed, network_of, put, toml_text, with_file_names
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.coverage import require_linear
from noack.theory.response_bounds import NotDecayingError
from noack.theory.trigger_norm import input_norm
from noack.theory.witnesses.effort import MOST_WORK
from noack.trigger_policies.decaying import DecayingSettings

_POLICY = "decaying"
"""The rule whose threshold is chosen."""
_FLOOR_SHARE = 0.05
"""The floor of the threshold, as a share of beta."""
_LARGEST_FLOOR_SHARE = 0.5
"""The largest floor that is tried for the allowed errors, as a share of beta."""
_FASTEST_ALPHA_PER_S = 1.0
"""α is at most this, unless allowed errors ask for a fast loop."""
_RATES_HZ = (1.0, 2.0, 5.0, 10.0, 20.0, 25.0, 50.0, 100.0, 200.0, 250.0, 500.0)
"""Rates that are chosen from: their periods are whole milliseconds."""
_FASTEST_EIGENVALUE_PER_S = 1000.0
"""Faster eigenvalues do not determine the rate: no loop can follow them."""
_STEPS_PER_TIME_CONSTANT = 50
"""Least number of steps of the plant in the time constant of the loop's fastest eigenvalue."""
_OTHER_WEIGHT = 0.01
"""Weight of a state without an allowed error in the regulator, where others have one, with weight 1."""
_INPUT_WEIGHTS = (1.0, 10.0, 100.0)
"""r of the regulators that are tried: with a larger one the gain is slower."""
_FRICTION_INPUT_WEIGHTS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4)
"""The same with allowed errors and friction, which keeps an output off by its size over the gain."""
_USUAL_INPUT = 20.0
"""The largest entry of a column of B for which these r hold. With another one r is such that the loop is the
same: the unit of an input does not matter."""
_LEAST_EFFECT = 1e-6
"""Smaller effects, relative to the usual one, count as this one: no Riccati equation is solved beyond."""
_SMALL_EFFECT = 0.1
"""With a smaller entry of B, per second, the weights 1 of a state and of an input give a slow loop."""
_STICKING_SHARE = 0.25
"""Of an allowed error, friction takes at most this, if a gain is stiff enough."""
_SIZE_STEPS, _SIZE_TIME_CONSTANTS, _LEAST_SIZE = 400, 5.0, 1e-3
"""How long and how finely the linear loop is followed to see how large its states become; the least size
of one, as a share of the largest."""
_LOOSE_BOUND_RATIO = 200.0
"""A bound of ‖x‖ above this multiple of ‖x(0)‖ is used only if there is no other."""
_DEFAULT_START = 0.1
"""x(0) of a state, if the plant has none."""
_MOST_THRESHOLDS = 3
"""Last thresholds that are tried for the allowed errors."""
_FRICTION_FLOOR_SHARE = 0.15
"""The first last threshold of a plant with friction, as a share of the first allowed error."""
_SLOWER = 0.5
"""Factor of α if nothing is proven with it."""
_LEAST_USE, _MOST_USE = 0.6, 0.85
"""Shares of an allowed error that its bound has in the end: at least, and wanted."""
_BESIDE = 1e-12
"""How far beside a point ẋ is compared, relative to it: a difference is a jump."""
_MOST_OUTPUTS = 4
"""Outputs of a plant that states no allowed error."""
_START_FACTOR, _MOST_REDUCTIONS = 0.5, 5
"""If the loop does not return, x(0) is multiplied by this factor, at most this number of times."""
_LONGEST_RUN_S = 20.0
"""Wall time of a live run; a longer horizon runs faster."""
_SHORTEST_HORIZON_S = 4.6
"""A shorter run would show little."""
_HORIZON_FACTOR = 1.2
"""A run lasts at least this times as long as until its outputs are guaranteed to stay where they may be."""
_MOST_STEPS_PER_TIME_CONSTANT = 1e6
"""Of a slower loop, each simulation would take minutes or more."""
_LONGEST_HORIZON_S, _HIGHEST_SPEED = 1e7, 1000.0
"""The largest that a scenario may have."""


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


@dataclass(frozen=True)
class _Trial:
    """A loop with settings that are tried together."""

    gain: LoopGain
    rate_hz: float
    mansd: int
    alpha_per_s: float
    x0: Vector
    weight: Matrix | None = None
    has_friction: bool = False
    """Whether friction keeps the plant from x = 0: then a search takes the longest."""
    floor: float | None = None
    """Last threshold; None: a share of the first one."""
    guaranteed_from_s: float = 0.0
    """When all outputs are guaranteed to stay within their allowed errors."""


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
    if (policy := values.get("trigger.policy", _POLICY)) != _POLICY:
        raise CallerError(
            f'trigger.policy = {policy}: noack new chooses a threshold, of policy "{_POLICY}"; give another '
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
        first = gain(model, q=_state_weights(model, errors), r=_input_weights(model, 1.0))
        plant_model = model = beside_steps(model, _sizes(first, x0))
    trials = _TrialScenarios(model, Path(path), fixed, errors)
    best = trials.search([*_list_trials(plant_model, x0, errors)], report)
    report("simulating")
    returns = trials.returns(best)
    for _ in range(_MOST_REDUCTIONS):
        if returns or fixed_state is not None or model.plant.initial_state is not None:
            break
        best = replace(best, x0=best.x0 * _START_FACTOR)
        returns = trials.returns(best)
    simulated = best
    best, results = trials.with_threshold(best, report)
    if trials.content(best) != trials.content(simulated):  # another threshold, fewer losses, a longer horizon
        report("simulating")
        returns = trials.returns(best)
    guarantee, of_plant = _guarantee(results), results.guaranteed is not None
    certificate = trials.certify(best)
    notes = (*_note_of_bounds(results, best.x0), *_notes(best, certificate, returns, of_plant=of_plant))
    if not isinstance(plant_model, LoopGain):
        notes += tuple(_note_of_input(best))
    text = _file_text(trials.content(best), (f"{guarantee}.", *notes), best, fixed)
    found_certificate = certificate if certificate.exists else None
    return NewScenario(best.gain, trials.scenario(best), text, found_certificate, guarantee, notes)


def _guarantee(results: Certificates) -> str:
    """Return the sentence of ``noack certify`` about the plant itself."""
    sentence = guarantee_sentence(results)
    if sentence is None:
        return f"no guarantee: {results.answer.text}"
    return sentence if is_within_allowed(results) else f"no guarantee of the allowed error: {sentence}"


def _note_of_bounds(results: Certificates, start: Vector) -> Iterator[str]:
    """Yield of each output whose proven bound is larger than its allowed error what this means."""
    certificate = results.guaranteed
    for bound in () if certificate is None else results.output_bounds(certificate):
        output, first = bound.output, abs(float(np.array(bound.output.row)[: len(start)] @ start))
        if bound.is_met:
            continue
        least = output.quantity(f"{bound.ultimate:.3g}")
        if bound.ultimate >= first:
            yield (
                f"The proven bound of {output.name}, {least}, is not smaller than its value at the start, "
                f"{output.quantity(f'{first:.3g}')}: it says only that {output.name} stays bounded."
            )
        yield (
            f"For a smaller bound of {output.name}, choose a slower gain (noack gain --r), fewer losses "
            "(--set network.mansd) or a smaller x(0) (--x0)."
        )


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
    for off in np.eye(model.plant.n) * _BESIDE * max(1.0, norm(model.at)):
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
    return np.where(is_rate, 0.0, _DEFAULT_START) if not all(is_rate) else np.full(n, _DEFAULT_START)


def _list_trials(
    model: LinearModel | LoopGain,
    x0: Vector,
    allowed: Mapping[str, float],
) -> Iterator[_Trial]:
    """Yield what is tried, the preferred settings first; states without an allowed error may move."""
    linear = model.model if isinstance(model, LoopGain) else model
    has_friction = linear.source == "beside"
    if isinstance(model, LoopGain):
        gains = [model]
    else:
        q = _state_weights(model, allowed)
        if allowed and has_friction:
            gains = [gain(model, q=q, r=_input_weights(model, r)) for r in _FRICTION_INPUT_WEIGHTS]
            gains = [each for each in gains if _sticks_within(each, x0, allowed)] or gains[-1:]
        else:
            gains = [gain(model, q=q, r=r) for r in _INPUT_WEIGHTS]
    is_tried, slowest_per_s = False, 0.0
    for loop_gain in gains:
        fastest = max(
            (size for size in np.abs(loop_gain.eigenvalues) if size < _FASTEST_EIGENVALUE_PER_S), default=1
        )
        least_rate_hz = _STEPS_PER_TIME_CONSTANT * fastest
        usual_hz = next((rate_hz for rate_hz in _RATES_HZ if rate_hz >= least_rate_hz), _RATES_HZ[-1])
        usual_hz = loop_gain.model.plant.rates.get("rate_hz", usual_hz)
        slowest_per_s = usual_hz / _MOST_STEPS_PER_TIME_CONSTANT
        if loop_gain.decay_per_s < slowest_per_s:
            continue
        is_tried = True
        is_fixed = loop_gain.model.plant.system.has_own_step
        # Delays cost most with the stiff gain that friction needs.
        usual_hz = 2 * usual_hz if has_friction and not is_fixed else usual_hz
        for rate_hz in (usual_hz,) if is_fixed or has_friction else (usual_hz, 2 * usual_hz):
            for mansd in range(DEFAULT_MANSD, 0, -1):
                for share in (ALPHA_SHARE / 2,) if has_friction else (ALPHA_SHARE, ALPHA_SHARE / 2):
                    fastest_per_s = math.inf if allowed else _FASTEST_ALPHA_PER_S
                    alpha = to_digits(min(share * loop_gain.decay_per_s, fastest_per_s))
                    weight = _unit_weight(loop_gain, x0, allowed)
                    yield _Trial(loop_gain, rate_hz, mansd, alpha, x0, weight, has_friction)
    if not is_tried:
        raise CallerError(
            f"{linear.plant.label}: without errors x decays as e^(−{gains[0].decay_per_s:.3g}t) only, too "
            f"slowly for its fastest eigenvalue: at least e^(−{slowest_per_s:.3g}t) is needed; choose "
            "a faster gain with noack gain --q or --poles"
        )


def _state_weights(model: LinearModel, allowed: Mapping[str, float]) -> list[float] | None:
    """Return the weights of the states in the regulator; None: all are 1."""
    names = model.plant.state_names
    return [1.0 if name in allowed else _OTHER_WEIGHT for name in names] if allowed else None


def _input_weights(model: LinearModel, r: float) -> list[float]:
    """Return the weights of the inputs in the regulator, (m,), for one that has the usual effect."""
    effects = np.maximum(np.abs(model.B).max(axis=0) / _USUAL_INPUT, _LEAST_EFFECT)
    return [to_digits(r * effect**2) for effect in effects.tolist()]


def _sizes(loop: LoopGain, x0: Vector) -> Vector:
    """Return how large states and inputs become in the linear loop from x(0), (n + m,)."""
    A, B = loop.model.A, loop.model.B
    step_ns = round(_SIZE_TIME_CONSTANTS / loop.decay_per_s / _SIZE_STEPS * NS_PER_S)
    step, _ = discretise(A + B @ loop.K, np.zeros_like(B), max(step_ns, 1))
    x, largest = x0 if x0.any() else np.full(len(x0), _DEFAULT_START), np.zeros(len(A) + B.shape[1])
    for _ in range(_SIZE_STEPS):
        largest = np.maximum(largest, np.abs(np.concatenate([x, loop.K @ x])))
        x = step @ x
    return np.maximum(largest, _LEAST_SIZE * float(largest.max()))


def _sticks_within(loop: LoopGain, x0: Vector, allowed: Mapping[str, float]) -> bool:
    """Return whether friction keeps each allowed state off by a small share of its allowed error.

    Where the model is beside a step of a plant's derivative, the rest of the derivative is v, the same near
    and far. Against it the loop rests at (A + BK)⁻¹ v.
    """
    model, sizes = loop.model, _sizes(loop, x0)[: len(x0)]
    rates = getattr(model.plant.system_at(np.zeros_like(x0)), "rates", None)
    assert rates is not None  # a model beside a step is one of a derivative
    left_out, u = np.zeros_like(x0), np.zeros(model.B.shape[1])
    for size, x in zip(sizes, np.eye(len(x0)), strict=True):
        rests = [np.abs(rates(share * size * x, u) - model.A @ (share * size * x)) for share in (0.5, 1.0)]
        left_out += np.minimum(*rests)
    off = np.abs(np.linalg.inv(model.A + model.B @ loop.K)) @ left_out
    names = model.plant.state_names
    return all(off[names.index(name)] <= _STICKING_SHARE * error for name, error in allowed.items())


def _unit_weight(loop: LoopGain, x0: Vector, allowed: Mapping[str, float]) -> Matrix | None:
    """Return W of the trigger's norm, in units of the first allowed state; None without one.

    Errors of different units count by how large their states become.
    """
    if not allowed:
        return None
    sizes, names = _sizes(loop, x0)[: len(x0)], loop.model.plant.state_names
    first = sizes[names.index(next(iter(allowed)))]
    return np.diag([to_digits(first / size, 2) for size in sizes])


class _TrialScenarios:
    """Builds, certifies and simulates the scenarios of trials."""

    def __init__(
        self, model: LinearModel, path: Path, fixed_settings: ReadTable, allowed: Mapping[str, float]
    ) -> None:
        self._model, self._path, self._fixed_settings, self._allowed = model, path, fixed_settings, allowed
        self.is_linear = isinstance(model.plant.system, LinearSettings)
        self._near: Sequence[Mapping[str, object]] = ()
        """What was proven of the last trial."""

    def content(self, trial: _Trial) -> Table:
        """Return the content of the scenario file."""
        model, reference = self._model, self._model.plant
        start = trial.x0 if trial.weight is None else trial.weight @ trial.x0
        beta, alpha = to_digits(BETA_SHARE * norm(start) or BETA_SHARE), trial.alpha_per_s
        decayed_s, guaranteed_s = (
            math.log(1 / HORIZON_DECAY) / alpha,
            _HORIZON_FACTOR * trial.guaranteed_from_s,
        )
        horizon_s = max(decayed_s, guaranteed_s, _SHORTEST_HORIZON_S)
        horizon_s = min(to_digits(horizon_s), _LONGEST_HORIZON_S)
        weight = None
        if trial.weight is not None:
            weight = [[to_digits(entry, 6) for entry in row] for row in trial.weight]
        content: Table = {
            "name": "".join(c if c.isascii() and c.isalnum() else "_" for c in self._path.stem),
            "description": f"{reference.label} over a network{self._losses}.",
            "horizon_s": horizon_s,
            "speed": min(max(1.0, float(round(horizon_s / _LONGEST_RUN_S))), _HIGHEST_SPEED),
            "model": {
                "A": model.A.tolist(),
                "B": model.B.tolist(),
                "gain": trial.gain.K.tolist(),
                **({"integral": [*trial.gain.integrals]} if trial.gain.integrals else {}),
                "state_names": list(reference.state_names),
                **({"state_units": list(reference.units)} if self._has_own_units else {}),
                "input_names": list(reference.input_names),
            },
            "plant": {
                "initial_state": trial.x0.tolist(),
                "rate_hz": trial.rate_hz,
                "measure_every": int(reference.rates.get("measure_every", 1)),
                "system": self._system(),
            },
            "controller": {"rate_hz": trial.rate_hz},
            "trigger": {
                "policy": _POLICY,
                "beta": beta,
                "alpha_per_s": alpha,
                "floor": self._first_floor(trial, beta) if trial.floor is None else trial.floor,
                **({"weight": weight} if weight else {}),
            },
            "network": {
                "mansd": trial.mansd,
                "loss": {"model": "bernoulli", "probability": DEFAULT_LOSS_PROBABILITY},
            },
            "seeds": {"loss": 1},
            **({"outputs": outputs} if (outputs := self._outputs()) else {}),
        }
        for key, value in self._fixed_settings.items():
            put(content, key, value, f"--set {key}")
        return content

    @property
    def _has_own_units(self) -> bool:
        """Whether the units of the states are not those of the plant's kind, which a scenario has anyhow."""
        return any(self._model.plant.units) and not self._model.plant.system.states

    def _first_floor(self, trial: _Trial, beta: float) -> float:
        """Return the last threshold that is tried first."""
        floor = _FLOOR_SHARE * beta
        if self._allowed and not trial.has_friction and not self.is_linear:
            floor = _LARGEST_FLOOR_SHARE * beta
        if trial.has_friction and self._allowed:
            floor = min(_FRICTION_FLOOR_SHARE * next(iter(self._allowed.values())), beta / 2)
        return to_digits(floor, 3)

    def _outputs(self) -> list[Table]:
        """Return the outputs: the states with an allowed error, or those whose units are known."""
        units = dict(zip(self._model.plant.state_names, self._model.plant.units, strict=False))
        names = [*self._allowed] or [name for name, unit in units.items() if unit][:_MOST_OUTPUTS]
        outputs = list[Table]()
        for name in names:
            unit, allowed = units.get(name, ""), self._allowed.get(name)
            keys = {"unit": unit, "allowed": allowed}
            outputs.append({"name": name, **{key: value for key, value in keys.items() if value}})
        return outputs

    def with_threshold(self, trial: _Trial, report: Callable[[str], None]) -> tuple[_Trial, Certificates]:
        """Return the trial with the last threshold that the allowed errors need, and its certificates.

        A bound that does not decay is proportional to this threshold, where nothing disturbs the plant.
        """
        is_fixed = not self._fixed_settings.keys().isdisjoint(("trigger", "trigger.floor"))
        trial, results = proven = self._with_proof(trial, report)
        for number in range(_MOST_THRESHOLDS):
            if number:
                report(f"searching for proofs: threshold {number + 1}")
                results = self._proven(trial)
                if results.guaranteed is None:
                    trial, results = proven
                    break
            proven, used = (trial, results), results.scenario.trigger
            if results.guaranteed is None or is_fixed or not isinstance(used, DecayingSettings):
                break
            largest = self.largest_share(results)
            is_enough = largest <= 1.0 and (largest >= _LEAST_USE or trial.has_friction)
            if is_enough or number == _MOST_THRESHOLDS - 1:
                break
            wanted = to_digits(min(used.floor * _MOST_USE / largest, _LARGEST_FLOOR_SHARE * used.beta), 2)
            if wanted == used.floor:
                break
            trial = replace(trial, floor=wanted)
        if results.guaranteed is not None:
            times_s = [bound.settles_s or 0.0 for bound in results.output_bounds(results.guaranteed)]
            trial = replace(trial, guaranteed_from_s=max(times_s, default=0.0))
        return trial, results

    def _with_proof(self, trial: _Trial, report: Callable[[str], None]) -> tuple[_Trial, Certificates]:
        """Return the trial with a decay of the threshold for which bounds are proven, else the first."""
        report("searching for proofs")
        first = trial, self._proven(trial)
        if first[1].guaranteed is not None or not self._allowed or "trigger" in self._fixed_settings:
            return first
        others = list(self._easier(trial))
        for number, other in enumerate(others, 2):
            report(f"searching for proofs: attempt {number} of {len(others) + 1}")
            if (results := self._proven(other)).guaranteed is not None:
                return other, results
        return first

    def _easier(self, trial: _Trial) -> Iterator[_Trial]:
        """Yield trials of which more is proven: with a smaller or slower threshold, and fewer losses."""
        used = self.scenario(trial).trigger
        if isinstance(used, DecayingSettings) and not trial.has_friction and not self.is_linear:
            trial = replace(trial, floor=to_digits(_FLOOR_SHARE * used.beta, 2))
            yield trial
        if "trigger.alpha_per_s" not in self._fixed_settings:
            trial = replace(trial, alpha_per_s=to_digits(_SLOWER * trial.alpha_per_s))
            yield trial
        if self._fixed_settings.keys().isdisjoint(("network", "network.mansd")):
            fewer = dict.fromkeys((trial.mansd // 2, 1))
            yield from (replace(trial, mansd=mansd) for mansd in fewer if 0 < mansd < trial.mansd)

    def _proven(self, trial: _Trial) -> Certificates:
        """Return the certificates of a trial, with the bounds that are proven."""
        results = certificates_of(self.scenario(trial))
        most_work = 2 * RUN_WORK if self.is_linear else MOST_WORK
        found = results.prove(most_work=most_work, conditions=("schedule",), near=self._near)
        self._near = [each.document for each in found.statements if each.document is not None] or self._near
        return results

    @staticmethod
    def largest_share(results: Certificates) -> float:
        """Return the largest share of an allowed error that its bound has in the end.

        It is infinite without a bound.
        """
        if results.guaranteed is None:
            return math.inf
        outputs = [bound for bound in results.output_bounds(results.guaranteed) if bound.output.allowed]
        return max((bound.ultimate / (bound.output.allowed or 1.0) for bound in outputs), default=1.0)

    @property
    def _losses(self) -> str:
        is_given = any(key.startswith("network") for key in self._fixed_settings)
        return "" if is_given else " that loses half of the updates"

    def _system(self) -> Table:
        """Return the table plant.system, with a file's name relative to the scenario's folder."""
        system, model = self._model.plant.system, self._model
        table = system.content()
        if isinstance(file := table.get("file"), str):
            table["file"] = os.path.relpath(file, self._path.absolute().parent)
            table.pop("sha256", None)
        if system.has_operating_point:
            for key, value in (("operating_state", model.at), ("operating_input", model.input)):
                if value.any():
                    table[key] = (value + np.array(getattr(system, key) or 0.0)).tolist()
        return {key: value for key, value in table.items() if value not in ({}, [])}

    def scenario(self, trial: _Trial) -> Scenario:
        """Return the loaded scenario."""
        return completed(self.content(trial), self._path)

    def certify(self, trial: _Trial) -> ScenarioCertificate:
        """Return the certificate of a trial's linear plant that needs no search, perhaps void."""
        resolved = resolve(self.scenario(trial))
        if not resolved.coverage.is_linear:
            A, B = (tuple(map(tuple, M.tolist())) for M in resolved.model.matrices)
            linear = {"system": LinearSettings(), "draw": "given", "A": A, "B": B}
            resolved = resolved.model_copy(update={"plant": resolved.plant.model_copy(update=linear)})
        resolved.coverage.require_unchanging()
        require_linear(resolved)
        return quick_certificate(resolved)

    def search(self, trials: Sequence[_Trial], report: Callable[[str], None]) -> _Trial:
        """Return the trial that is used."""
        candidates: list[tuple[float, _Trial]] = []
        if trials[0].has_friction and self._allowed:
            return trials[0]  # only a proof about the plant itself counts
        contents = set[str]()
        easiest = {(id(trial.gain), trial.rate_hz): trial for trial in trials}  # the last: fewest losses
        for number, trial in enumerate(trials):
            report(f"certifying: {number + 1} of {len(trials)}")
            loop, content = (id(trial.gain), trial.rate_hz), str(self.content(trial))
            if loop not in easiest or content in contents:  # the given settings exclude it
                continue
            contents.add(content)
            bound = self.certify(trial).first("x")
            if bound is None:
                if not self.certify(easiest[loop]).exists:
                    del easiest[loop]
                continue
            candidates.append((bound / (norm(trial.x0) or 1.0), trial))
            if candidates[-1][0] <= _LOOSE_BOUND_RATIO:
                return trial
        return min(candidates, key=lambda entry: entry[0])[1] if candidates else self._weighted(trials[0])

    def _weighted(self, trial: _Trial) -> _Trial:
        """Return a trial in another norm if that certifies it."""
        model, K = trial.gain.model, trial.gain.K
        if trial.gain.integrals or trial.weight is not None:  # W is of the states alone
            return trial
        with suppress(NotDecayingError):
            weight = input_norm(model.A + model.B @ K, K, trial.alpha_per_s)
            weighted = replace(trial, weight=weight)
            if self.certify(weighted).exists:
                return weighted
        return trial

    def returns(self, trial: _Trial) -> bool:
        """Whether the loop settles in virtual time, as the verdict of a run has it.

        Raises:
            CallerError: the plant cannot be simulated.
        """
        run = simulate_loops(resolve_run(self.scenario(trial)))
        for notice in run.loop().notices:
            if notice["level"] == "failed":
                raise CallerError(f"{self._model.plant.label}: {notice['text']}")
        sizes = np.linalg.norm(run.loop().columns("plant_step", "x")["x"], axis=1)
        return bool(np.isfinite(sizes).all() and sizes[-1] <= SETTLED_SHARE * sizes.max())


def _notes(
    trial: _Trial, certificate: ScenarioCertificate, returns: bool, *, of_plant: bool
) -> Iterator[str]:
    """Yield what was chosen and found, a sentence each; ``of_plant``: a guarantee is for the plant itself."""
    yield f"u = K x_c: {trial.gain.method}; without errors x decays as e^(−{trial.gain.decay_per_s:.3g}t)."
    plant = "the plant" if of_plant else "the linear plant ẋ = Âx + B̂u"
    if of_plant:
        pass
    elif not certificate.has("x"):
        yield (
            f"No certificate was found for {plant}: {certificate.void}. Rates, gains and M were "
            "tried; noack certify tries other settings, and names those with a certificate."
        )
    else:
        bound = certificate.formula("‖x‖", "x")
        losses = certificate.conditions.guarantee.meaning
        yield f"Certified for {plant}, for every pattern of losses with {losses}: {bound}."
    if not of_plant:
        errors = ", ".join(
            f"{of_states.max():.2g} within ±{within:g}" for within, of_states in trial.gain.model.errors
        )
        yield (
            "This is not about the plant itself. If its equations are known, noack certify searches a "
            "certificate of them; without one, a run checks only what "
            "holds for every plant; with --set 'plant.system={kind=\"linear\"}' a run has the "
            "linear plant, and is checked against its certificate. Largest relative error of the "
            f"linear model, sampled: {errors}."
        )
    start = ", ".join(f"{entry:.3g}" for entry in trial.x0)
    end = "returns to 0" if returns else "does not return to 0"
    yield f"Simulated from x(0) = ({start}), the loop {end}."


def _note_of_input(trial: _Trial) -> Iterator[str]:
    """Yield what to do if the regulator, which weighs inputs like states, hardly uses an input."""
    effect = float(np.abs(trial.gain.model.B).max(initial=0.0))
    if not trial.has_friction and 0 < effect < _SMALL_EFFECT:
        label = trial.gain.model.plant.label
        yield (
            f"One unit of an input changes states by at most {effect:.2g} per second, so it is used little. "
            f"For a faster loop: noack gain {label} --r R --out gain.json, R below 1; noack new gain.json."
        )


_COMMENTS = {
    "horizon_s": "Length of the run in simulated time.",
    "speed": "Simulated time per wall time of a live run.",
    "model": "What sensor and controller know of the plant: ẋ = A x + B u, per second.",
    "plant": "The true plant.",
    "plant.initial_state": "x(0), one number per state.",
    "plant.rate_hz": "Steps of the plant per second of simulated time.",
    "plant.measure_every": "Steps per measurement.",
    "controller.rate_hz": "Inputs per second of simulated time.",
    "trigger": "The sensor transmits when the error of its model exceeds the threshold "
    "max(beta e^(−alpha_per_s t), floor).",
    "trigger.beta": "The first threshold. Larger: fewer transmissions, larger errors.",
    "trigger.floor": "The last threshold. With 0, x converges to 0.",
    "trigger.weight": "W of the norm ‖W e‖ of errors, chosen for the certificate.",
    "network.mansd": "Maximum consecutive losses, M − 1. The network delivers the next packet.",
    "network.loss": "Losses, before this limit is applied.",
    "seeds": "Another number: other losses.",
    "outputs": "What you want to know, in its own unit, and how far it may be from its set-point.",
}
"""Comments of the file, by table and key."""
_REASONS = {
    "horizon_s": " Until its end e^(−alpha_per_s t) falls to a hundredth, and what is guaranteed has begun.",
    "trigger.beta": " It is a tenth of the norm of x(0).",
}
"""How values are chosen that are not given."""


def _file_text(content: ReadTable, notes: Sequence[str], trial: _Trial, fixed_settings: ReadTable) -> str:
    """Return the file: the content with comments."""
    poles, decay = eigenvalue_text(trial.gain.eigenvalues), trial.gain.decay_per_s
    comments = _COMMENTS | {
        "model.gain": f"u = gain x_c. {trial.gain.method}; eigenvalues of A + B gain: {poles} /s.",
        "trigger.alpha_per_s": f"Must be below the decay rate of A + B gain, {decay:.4g} /s.",
    }
    comments |= {key: comments[key] + reason for key, reason in _REASONS.items() if key not in fixed_settings}
    lines = [f"# A scenario for {trial.gain.model.plant.label}, written by `noack new`."]
    lines += [line for note in notes for line in _comment_lines(note)]
    return "\n".join([*lines, *_section_lines("", content, comments), ""])


def _section_lines(name: str, table: ReadTable, comments: Mapping[str, str]) -> list[str]:
    lines = _comment_lines(comments.get(name, ""))
    lines = ["", *lines, f"[{name}]"] if name else lines
    inner: list[str] = []
    for key, value in table.items():
        path = f"{name}.{key}" if name else key
        if isinstance(value, dict):
            inner += _section_lines(path, value, comments)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            inner += ["", *_comment_lines(comments.get(path, ""))]
            for entry in value:
                inner += [f"[[{path}]]", *toml_text(entry).splitlines()]
        else:
            lines += _comment_lines(comments.get(path, "")) + toml_text({key: value}).splitlines()
    return lines + inner


def _comment_lines(text: str) -> list[str]:
    return textwrap.wrap(text, 98, initial_indent="# ", subsequent_indent="# ")
