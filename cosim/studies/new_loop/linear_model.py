"""The linear model of a plant at a point, and the gain of a loop with it."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.record.run_directory import write_output
from cosim.studies.new_loop.plant_reference import PlantReference, plant_reference
from cosim.studies.regulator import lqr_gain
from netem.core.errors import CallerError
from netem.core.json_text import parse_json
from netem.core.number_checks import real_number
from netem.core.number_format import TextRows, as_text, to_digits
from netem.core.settings_section import ReadTable, Table
from noack.core.linear_systems import Matrix, Vector, norm
from noack.core.pole_placement import place_poles
from noack.plants.systems.linearisation import LinearMotion, largest_errors
from noack.plants.systems.linearisation import linearise as linear_motion
from noack.scenario.given_settings import given_settings
from noack.scenario.integrals import augmented, require_held
from noack.scenario.sections import instability
from noack.settings.user_files import UserCode

TOLERANCE = 1e-6
"""Relative size below which an entry of the controllability matrix is 0."""
_PROJECTION_ROUNDING = 1e-14
"""Rounding of a projection, relative to what is projected."""
_DRIFT_ROUNDING = 1e-6
"""A drift below this share of the largest entry of A and B is rounding."""
_ROUGH_SHARE = 0.5
"""A plant is not smooth if its error in a tenth of a neighbourhood is more than this share of that in all
of it; a tenth is expected."""
_USUAL = 0.1
"""A usual deviation from a point, relative to the component or 1."""
_SMALL_ERROR = 1e-3
"""An error below this may be rounding."""
_IMAGINARY_ROUNDING = 1e-7
"""Imaginary parts below this share of the largest eigenvalue are 0."""
_EIGENVALUE_ROUNDING = 1e-12
"""Eigenvalues below this share of the largest one are 0."""
_GAIN_DIGITS = 10
"""Significant digits of the entries of K: what remains is below the errors of any model."""
Complex = NDArray[np.complex128]


class SampledError(NamedTuple):
    """The error of a linear model in a neighbourhood of its point."""

    within: float
    """Half-width of the neighbourhood, in each coordinate's units."""
    of_states: Vector
    """Largest sampled error of each state's derivative, relative, (n,)."""


Source = Literal["derivative", "beside", "motion", "exact", "known"]


@dataclass(frozen=True)
class LinearModel:
    """A plant's linear model ẋ ≈ drift + A (x − at) + B (u − input); n states, m inputs.

    ``A``, (n, n), and ``B``, (n, m), are per second. ``eigenvalues`` are those of A, ``rank`` is
    that of the controllability matrix, and no input changes the eigenvalues ``uncontrollable``.
    """

    plant: PlantReference
    A: Matrix
    B: Matrix
    at: Vector
    input: Vector
    drift: Vector
    source: Source
    """Where A and B are from, in this order: differences of the plant's derivative, the logarithm of
    its motion over a step, its own matrices, or the loop's Â and B̂."""
    errors: tuple[SampledError, ...]

    @property
    def eigenvalues(self) -> Complex:
        """Eigenvalues of A, per second, the largest real part first."""
        return eigenvalues(self.A)

    @property
    def rank(self) -> int:
        """Rank of the controllability matrix."""
        return len(self.controllable.T)

    @cached_property
    def controllable(self) -> Matrix:
        """An orthonormal basis of the controllable states, (n, rank)."""
        return controllable_states(self.A, self.B)

    @property
    def uncontrollable(self) -> Complex:
        """The eigenvalues that no input changes, per second."""
        complement = np.linalg.svd(np.hstack([self.controllable, 0 * self.A]))[0][:, self.rank :]
        return eigenvalues(complement.T @ self.A @ complement)

    @property
    def rests(self) -> bool:
        """Whether the plant rests at the point."""
        scale = np.abs(np.hstack([self.A, self.B])).max(axis=1)
        return bool((np.abs(self.drift) <= _DRIFT_ROUNDING * scale).all())

    def to_json(self) -> Table:
        """Return the document of ``noack linearise --json``."""
        arrays = {key: getattr(self, key).tolist() for key in ("at", "input", "A", "B", "drift")}
        errors = [{"within": within, "of_states": of_states.tolist()} for within, of_states in self.errors]
        return (
            {"plant": self.plant.label, "settings": self.plant.settings}
            | arrays
            | {
                "is_equilibrium": self.rests,
                "source": self.source,
                "errors": errors,
                "eigenvalues": _real_and_imaginary(self.eigenvalues),
                "rank": self.rank,
                "tolerance": TOLERANCE,
                "uncontrollable": _real_and_imaginary(self.uncontrollable),
                "is_stabilisable": bool((self.uncontrollable.real < 0).all()),
            }
        )

    def __repr__(self) -> str:
        states, inputs = self.plant.state_names, self.plant.input_names
        matrices = np.hstack([self.A, self.B])
        return "\n".join([_matrix_text("Â, B̂", matrices, states, states + inputs), *self._sentences()])

    @property
    def origin(self) -> str:
        """Where A and B are from."""
        if self.source == "known":
            return "the scenario's [model], which sensor and controller know of the plant"
        source = {
            "derivative": "differences of the plant's derivative",
            "beside": "differences of the plant's derivative, beside a steep step, as of friction",
            "motion": f"the matrix logarithm of the plant's motion over {self.plant.step_ns * 1e-9:g} s",
            "exact": "the plant's own matrices",
        }[self.source]
        return f"{source}, at x = {_vector_text(self.at)}, u = {_vector_text(self.input)}"

    def _sentences(self) -> Iterator[str]:
        yield f"computed from {self.origin}"
        if not self.rests:
            move, *_ = np.linalg.lstsq(np.hstack([self.A, self.B]), -self.drift, rcond=None)
            x, u = np.split(np.concatenate([self.at, self.input]) + move, [len(self.A)])
            yield f"no equilibrium: ẋ = {_vector_text(self.drift)} there"
            yield f"the linear model rests at x = {_vector_text(x)}, u = {_vector_text(u)}"
        for within, error in self.errors:
            worst = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
            name = self.plant.state_names[worst]
            yield f"relative error within ±{within:g}, sampled: up to {error[worst]:.2g} ({name})"
        if self.is_rough:
            yield "the error does not shrink with the neighbourhood: the plant is not smooth there"
        yield f"eigenvalues: {eigenvalue_text(self.eigenvalues)} /s"
        yield f"controllable: {self.rank} of {len(self.A)} states (tolerance {TOLERANCE:g})"
        if len(uncontrollable := self.uncontrollable):
            effect = "stable" if uncontrollable[0].real < 0 else "no gain stabilises the plant"
            yield f"not controllable: the eigenvalues {eigenvalue_text(uncontrollable)} /s: {effect}"

    @property
    def is_rough(self) -> bool:
        """Whether the errors of the states hardly shrink with the neighbourhood."""
        if not self.errors:
            return False
        wide, narrow = (error.of_states for error in self.errors)
        return bool((narrow > np.maximum(_ROUGH_SHARE * wide, _SMALL_ERROR)).any())

    @property
    def largest_error(self) -> float:
        """The relative error of the worst state in the wider neighbourhood."""
        return float(np.where(np.isnan(wide := self.errors[0].of_states), np.inf, wide).max())


@dataclass(frozen=True)
class LoopGain:
    """A linear model and the gain ``K``, (m, n), of u = K x; ``eigenvalues`` are those of A + BK.

    ``method`` says how K was computed. With ``integrals``, the rows of k outputs by their names, K is
    (m, n + k), its last columns those of ∫(r − y), and A and B are those of n + k states.
    """

    model: LinearModel
    K: Matrix
    method: str
    integrals: Mapping[str, Vector] = field(default_factory=dict)

    @property
    def eigenvalues(self) -> Complex:
        """Eigenvalues of A + BK, per second, the largest real part first."""
        A, B = _with_integrals(self.model, self.integrals)
        return eigenvalues(A + B @ self.K)

    @property
    def decay_per_s(self) -> float:
        """The decay rate of A + BK: the trigger's α must be below it."""
        return -float(self.eigenvalues[0].real)

    def to_json(self) -> Table:
        """Return the document of ``noack gain --json``: that of the model, and the gain."""
        return self.model.to_json() | {
            "gain": self.K.tolist(),
            **({"integral": [*self.integrals]} if self.integrals else {}),
            "method": self.method,
            "closed_loop_eigenvalues": _real_and_imaginary(self.eigenvalues),
            "alpha_below_per_s": self.decay_per_s,
        }

    def __repr__(self) -> str:
        plant = self.model.plant
        names = [*plant.state_names, *(f"∫(r − {name})" for name in self.integrals)]
        integral = f", integral = {json.dumps([*self.integrals])}" if self.integrals else ""
        return "\n".join(
            [
                _matrix_text("K", self.K, plant.input_names, names),
                f"u = K x{', and the integrals' if self.integrals else ''}; {self.method}",
                f"in a scenario's [model]: gain = {self.K.tolist()}{integral}",
                f"Â and B̂ are computed from {self.model.origin}",
                f"eigenvalues of Â + B̂K: {eigenvalue_text(self.eigenvalues)} /s",
                f"trigger.alpha_per_s must be below {self.decay_per_s:.4g}; half of it is usual",
            ]
        )


def linearise(
    plant: str | PathLike[str],
    *,
    at: Sequence[float] | float | None = None,
    input: Sequence[float] | float | None = None,  # noqa: A002 # the option of the command
    settings: ReadTable | None = None,
    within: float = 0.1,
) -> LinearModel:
    """Linearise a plant about a point.

    >>> import noack
    >>> noack.linearise("cart_pole").rank
    4

    Args:
        plant: ``"file.py:Class"``, a kind of plant, a scenario, a file that ``noack linearise`` or
            ``noack gain`` wrote, or what a kind of an extension takes, e.g. a file.
        at: x at the point, n entries, or a number if n is 1; by default 0.
        input: u there, m entries, or a number if m is 1; by default 0.
        settings: values by the keys of a scenario, e.g. ``{"plant.system.cart_kg": 1.0}``.
        within: half-width of the neighbourhood in which the error is sampled, in each coordinate's
            units; a tenth of it is sampled, too.

    Raises:
        NoackError: there is no such plant, it has no linear model there, or a value is wrong.
    """
    plant, settings = str(plant), dict(given_settings(settings))
    if plant.endswith(".json"):
        document = read_document(Path(plant))
        return linearise(
            document["plant"],
            at=document["at"] if at is None else at,
            input=document["input"] if input is None else input,
            settings=document["settings"] | settings,
            within=within,
        )
    if not np.isfinite(real_number("within", within, above=0.0)):
        raise CallerError(f"within {within:g}: expected a finite number")
    at, input = ([values] if isinstance(values, float | int) else values for values in (at, input))  # noqa: A001
    sizes = (None if at is None else len(at), None if input is None else len(input))
    reference = plant_reference(plant, settings, sizes)
    x, u = parse_vector("at", at, reference.n, "states"), parse_vector("input", input, reference.m, "inputs")
    point = _Point(reference, x, u, within)
    with np.errstate(all="ignore"):
        if (exact := reference.matrices or reference.system.linearisation()) is not None:
            return point.model(LinearMotion(*exact, exact[0] @ x + exact[1] @ u, "motion"), "exact")
        model = point.moved()
        if not model.is_rough or model.source != "derivative":
            return model
        usual = _USUAL * np.maximum(1.0, np.abs(np.concatenate([x, u])))
        return min(model, point.moved(usual), key=lambda each: each.largest_error)


class _Point(NamedTuple):
    """A point of a plant, about which its models are."""

    plant: PlantReference
    x: Vector
    u: Vector
    within: float

    def moved(self, beside: Vector | None = None) -> LinearModel:
        """Return the model by the plant's derivative or motion; see :func:`linear_motion`."""
        plant = self.plant
        motion = linear_motion(
            plant.system_at, plant.n, plant.m, x0=self.x, u0=self.u, step_ns=plant.step_ns, beside=beside
        )
        return self.model(motion, motion.source if beside is None else "beside")

    def model(self, motion: LinearMotion, source: Source) -> LinearModel:
        """Return a model with its sampled errors; raise CallerError if there is none."""
        plant, errors = self.plant, []
        if motion.void is not None:
            raise CallerError(f"{plant.label}: no linear model: {motion.void}")
        for width in () if plant.matrices else (self.within, self.within / 10):
            halfwidths = np.full(plant.n + plant.m, width)
            of_states = largest_errors(
                plant.system_at, motion, halfwidths, x0=self.x, u0=self.u, step_ns=plant.step_ns
            )
            errors.append(SampledError(width, of_states))
        return LinearModel(plant, motion.A, motion.B, self.x, self.u, motion.drift, source, tuple(errors))


def beside_steps(model: LinearModel, sizes: Vector) -> LinearModel:
    """Return the model of a plant beside the steps of its derivative, as of friction; else the same.

    Args:
        model: at a point.
        sizes: usual deviations of x and u from it, (n + m,).
    """
    if model.source not in ("derivative", "beside"):
        return model
    with np.errstate(all="ignore"):
        found = _Point(model.plant, model.at, model.input, model.errors[0].within).moved(sizes)
    is_same = np.array_equal(found.A, model.A) and np.array_equal(found.B, model.B)
    return model if is_same or not np.isfinite(found.A).all() else found


def gain(
    plant: str | PathLike[str] | LinearModel,
    *,
    q: ArrayLike | None = None,
    r: ArrayLike | None = None,
    poles: Sequence[complex] | None = None,
    integral: str | Sequence[str] = (),
    settings: ReadTable | None = None,
) -> LoopGain:
    """Compute the gain K of u = K x: a linear-quadratic regulator, or given eigenvalues.

    For a scenario with a linear plant it is that of Â and B̂, which sensor and controller know. With n
    states and m inputs, K is (m, n).

    >>> import noack
    >>> noack.gain("double_integrator").K.round(3).tolist()
    [[-1.0, -1.732]]

    Args:
        plant: a linear model, or a plant as for :func:`linearise`.
        q: weight of the states in ∫ xᵀQx + uᵀRu dt: a number, or the diagonal; by default 1.
        r: weight of the inputs, likewise.
        poles: the eigenvalues of the controllable part of A + BK instead, per second.
        integral: outputs or states whose distances from the reference are integrated: K has a column
            for each after those of the states, and q and poles have entries for them.
        settings: as for :func:`linearise`.

    Raises:
        NoackError: an unstable eigenvalue is not controllable, an output cannot be held, or a value is
            wrong.
    """
    model = plant if isinstance(plant, LinearModel) else linearise(plant, settings=settings)
    if model is not plant and (known := model.plant.model_matrices) is not None:
        model = replace(model, A=known[0], B=known[1], source="known")
    plain, integrals = model, _integrals(model, [integral] if isinstance(integral, str) else integral)
    A, B = _with_integrals(model, integrals)
    model = replace(model, A=A, B=B)  # of the states and the integrals
    label, uncontrollable = model.plant.label, model.uncontrollable
    if len(uncontrollable) and uncontrollable[0].real >= 0:
        worst = eigenvalue_text(uncontrollable[:1].real + 1j * np.abs(uncontrollable[:1].imag))
        raise CallerError(f"{label}: no gain stabilises it: the eigenvalue {worst} /s is not controllable")
    if poles is None:
        Q, R = (_weight_matrix(*weight) for weight in (("q", q, model.A), ("r", r, model.B.T)))
        try:
            K = lqr_gain(model.A, model.B, Q, R)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise CallerError(f"{label}: no linear-quadratic regulator: {error}") from None
        method = f"linear-quadratic regulator, Q = {_diagonal_text(Q)}, R = {_diagonal_text(R)}"
    elif q is not None or r is not None:
        raise CallerError("poles: give either these or the weights q and r")
    else:
        pole_values = np.atleast_1d(_numbers("poles", poles, np.complex128))
        K, method = _place_poles(model, pole_values), f"poles {eigenvalue_text(pole_values)} /s"
    K = np.array([[to_digits(value, _GAIN_DIGITS) for value in row] for row in K])
    if (reason := instability(model.A, model.B, K)) is not None:
        raise CallerError(f"{label}: {reason}")
    return LoopGain(plain, K, method, integrals)


def _integrals(model: LinearModel, names: Sequence[str]) -> Mapping[str, Vector]:
    """Return the rows of outputs by their names; raise CallerError if one cannot be held."""
    rows = dict(zip(model.plant.state_names, np.eye(len(model.A)), strict=True)) | dict(model.plant.outputs)
    for name in names:
        if name not in rows:
            raise CallerError(
                f"integral {name}: no output or state of this name; these are {', '.join(rows)}"
            )
    chosen = {name: rows[name] for name in names}
    try:
        require_held(model.A, model.B, chosen)
    except ValueError as error:
        raise CallerError(f"integral: {error}") from None
    return chosen


def _with_integrals(model: LinearModel, integrals: Mapping[str, Vector]) -> tuple[Matrix, Matrix]:
    """Return A and B of a model's states, and of the integrals of outputs."""
    n = len(model.A)
    return augmented(model.A, model.B, np.array([*integrals.values()]).reshape(-1, n))


def _place_poles(model: LinearModel, poles: Complex) -> Matrix:
    basis = model.controllable
    if not np.isfinite(poles).all() or (poles.real >= 0).any():
        raise CallerError("poles: they need negative real parts, e.g. -1,-2+1j,-2-1j")
    if len(poles) != model.rank:
        raise CallerError(f"poles: {len(poles)} given; the controllable part has {model.rank} eigenvalues")
    try:
        return place_poles(basis.T @ model.A @ basis, basis.T @ model.B, poles) @ basis.T
    except ValueError as error:
        raise CallerError(f"poles: {error}") from None


def _weight_matrix(key: str, weights: ArrayLike | None, matrix: Matrix) -> Matrix:
    """Return a diagonal weight with an entry for each row of ``matrix``."""
    size, values = len(matrix), np.atleast_1d(_numbers(key, 1.0 if weights is None else weights))
    if values.shape not in ((1,), (size,)):
        raise CallerError(f"{key}: {values.size} numbers; give 1 or {size}")
    if not (np.isfinite(values).all() and (values >= 0).all() and (key == "q" or values.all())):
        raise CallerError(f"{key}: {values.tolist()}; positive numbers are needed")
    return np.diag(np.full(size, values))


def _diagonal_text(matrix: Matrix) -> str:
    values = np.diag(matrix)
    if (values == values[0]).all():
        return "I" if values[0] == 1 else f"{values[0]:g} I"
    return f"diag({', '.join(f'{value:g}' for value in values)})"


def controllable_states(A: Matrix, B: Matrix) -> Matrix:
    """Return an orthonormal basis of the range of the controllability matrix, (n, rank).

    It grows from the range of B by A times the directions found last. A direction counts if it is
    larger than the tolerance times the terms that it is the sum of. So neither the units of the
    states nor fast and slow eigenvalues decide.
    """
    basis, new, terms = np.zeros((len(A), 0)), B, np.abs(B)
    while new.shape[1] and basis.shape[1] < len(A):
        projection = np.eye(len(A)) - basis @ basis.T
        noise = TOLERANCE * norm(np.linalg.norm(np.abs(projection) @ terms, axis=1))
        noise += _PROJECTION_ROUNDING * norm(np.linalg.norm(terms, axis=1))
        directions, sizes, _ = np.linalg.svd(projection @ new, full_matrices=False)
        last = directions[:, sizes > noise]
        basis = np.linalg.qr(np.hstack([basis, last]))[0]
        new, terms = A @ last, np.abs(A) @ np.abs(last)
    return basis


def eigenvalues(matrix: Matrix) -> Complex:
    """Return the eigenvalues, the largest real part first."""
    values = np.linalg.eigvals(matrix).astype(np.complex128)
    return values[np.lexsort((values.imag, -values.real))]


def eigenvalue_text(values: Complex) -> str:
    """Return eigenvalues as text, conjugate pairs as one: "-0.81±0.5j, -5.8"."""
    scale, texts = max(1.0, float(np.abs(values).max(initial=0.0))), list[str]()
    for value in values:
        if value.imag > _IMAGINARY_ROUNDING * scale:
            texts.append(f"{value.real:.4g}±{value.imag:.4g}j")
        elif value.imag >= -_IMAGINARY_ROUNDING * scale:
            texts.append(f"{value.real if abs(value.real) > _EIGENVALUE_ROUNDING * scale else 0.0:.4g}")
    return ", ".join(texts)


def _numbers(key: str, entries: object, kind: type = np.float64) -> NDArray[Any]:
    """Return a number or a list of them as an array; raise CallerError if they are none."""
    try:
        return np.array(entries, dtype=kind)
    except (TypeError, ValueError):
        raise CallerError(f"{key}: {entries!r} is not a list of numbers") from None


def parse_vector(key: str, entries: object, size: int, meaning: str) -> Vector:
    """Return a given vector, (size,); None is 0. Raise CallerError if it is not one."""
    values = np.zeros(size) if entries is None else _numbers(key, entries)
    if values.shape != (size,):
        raise CallerError(f"{key}: {values.size} numbers; the plant has {size} {meaning}")
    if not np.isfinite(values).all():
        raise CallerError(f"{key}: {values.tolist()} has entries that are not finite")
    return values


def read_document(path: Path) -> dict[str, UserCode]:
    """Return the document of a file that ``noack linearise`` or ``noack gain`` wrote."""
    try:
        document = parse_json(path.read_bytes())
    except OSError as error:
        raise CallerError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        document = None
    kinds = {"plant": str, "settings": dict, "at": list, "input": list}
    if (
        not isinstance(document, dict)
        or not all(isinstance(document.get(key), kind) for key, kind in kinds.items())
        or document["plant"].endswith(".json")
    ):
        raise CallerError(f"{path}: not written by `noack linearise` or `noack gain`")
    return document


def write_document(result: LinearModel | LoopGain, path: Path) -> None:
    """Write the document of a model or a gain, not over that of another plant.

    Raises:
        CallerError: the file has another ending, or the model of another plant.
        MachineError: the file cannot be written.
    """
    if path.suffix != ".json":
        raise CallerError(f"--out {path}: the name of a model ends in .json")
    document = result.to_json()
    if path.exists() and (other_plant := read_document(path)["plant"]) != document["plant"]:
        raise CallerError(f"--out {path}: has the model of {other_plant}; give another name")
    write_output(path, json.dumps(document, indent=2))


def model_or_gain(plant: str | PathLike[str], settings: ReadTable | None) -> LinearModel | LoopGain:
    """Return the model of a plant, or of a file, and its gain if the file has one."""
    plant, model = str(plant), linearise(plant, settings=settings)
    if not plant.endswith(".json") or "gain" not in (document := read_document(Path(plant))):
        return model
    gain_rows = document["gain"]
    if not isinstance(gain_rows, list) or not all(isinstance(row, list) for row in gain_rows):
        raise CallerError(f"{plant}: gain: expected a list of rows")
    names = document.get("integral", [])
    if not isinstance(names, list):
        raise CallerError(f"{plant}: integral: expected a list of names")
    integrals = _integrals(model, names)
    meaning = "states and integrals" if integrals else "states"
    rows = [parse_vector("gain", row, len(model.A) + len(integrals), meaning) for row in gain_rows]
    if len(rows) != model.plant.m:
        raise CallerError(f"{plant}: gain: {len(rows)} rows; the plant has {model.plant.m} inputs")
    K = np.array(rows)
    if (reason := instability(*_with_integrals(model, integrals), K)) is not None:
        raise CallerError(f"{plant}: gain: {reason}")
    return LoopGain(model, K, str(document.get("method", "given")), integrals)


def _matrix_text(name: str, matrix: Matrix, rows: Sequence[str], columns: Sequence[str]) -> str:
    entries = ([f"{value:.6g}" for value in row] for row in matrix)
    table: TextRows = [[name, *columns], *([row, *cells] for row, cells in zip(rows, entries, strict=True))]
    return as_text(table)


def _vector_text(values: Vector) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def _real_and_imaginary(values: Complex) -> list[list[float]]:
    return [[float(value.real), float(value.imag)] for value in values]
