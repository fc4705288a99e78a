"""The linear model of a plant at a point: Â and B̂, their error, eigenvalues, controllable part."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from cosim.studies.new_loop.plant_reference import PlantReference, plant_reference, settings_of
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, norm, product
from noack.core.number_format import Rows, as_html, as_text
from noack.plants.linear import LinearSettings
from noack.plants.systems.linearisation import LinearMotion, largest_errors, linearise
from noack.settings.section import ReadTable, Table

TOLERANCE = 1e-6
"""Relative size below which an entry of the controllability matrix is 0."""
_REST = 1e-6
"""A drift below this share of the largest entry of A and B is rounding."""
_HALFWIDTH = 0.1
_ROUGH, _ROUGH_LEAST = 0.5, 1e-3
_REAL = 1e-7
"""Relative size below which an imaginary part is rounding."""
WRITTEN_BY = "noack linearise"
Complex = np.ndarray[tuple[int], np.dtype[np.complex128]]


@dataclass(frozen=True)
class LinearModel:
    """A plant's linear model ẋ ≈ f₀ + Â (x − x₀) + B̂ (u − u₀); n states, m inputs.

    Its attributes are ``A``, (n, n), and ``B``, (n, m), per second; the point ``at``, (n,), and
    ``input``, (m,); ``drift``, f₀; ``eigenvalues`` of Â; ``rank`` of the controllability matrix and
    ``uncontrollable``, the eigenvalues that no input changes; ``errors``, the error for each
    neighbourhood.
    """

    plant: PlantReference
    A: Matrix
    B: Matrix
    at: Vector
    input: Vector
    drift: Vector
    source: str
    """What A and B are computed from: "derivative", "motion", or "exact" if they are known."""
    errors: tuple[tuple[float, Vector], ...]
    """Half-width of the neighbourhood, and the relative error of each state, (n,)."""

    @property
    def eigenvalues(self) -> Complex:
        """Eigenvalues of Â, per second, the largest real part first."""
        return sorted_eigenvalues(self.A)

    @property
    def rank(self) -> int:
        """Rank of the controllability matrix [B, AB, …]."""
        return len(self.controllable.T)

    @cached_property
    def controllable(self) -> Matrix:
        """An orthonormal basis of the controllable states, (n, rank)."""
        return controllable_states(self.A, self.B)

    @property
    def uncontrollable(self) -> Complex:
        """The eigenvalues that no input changes, per second."""
        rest = (
            np.linalg.svd(self.controllable)[0][:, self.rank :]
            if self.rank
            else np.eye(len(self.A))
        )
        return sorted_eigenvalues(rest.T @ self.A @ rest)

    @property
    def rests(self) -> bool:
        """Whether the plant rests at the point."""
        scale = np.abs(np.hstack([self.A, self.B])).max(axis=1) + 1e-300
        return bool((np.abs(self.drift) <= _REST * scale).all())

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return self.plant.names[0] or tuple(f"x_{i}" for i in range(1, len(self.A) + 1))

    def to_json(self) -> Table:
        """Return the document of ``noack linearise --json``."""
        return {
            "written_by": WRITTEN_BY,
            "plant": {
                "label": self.plant.label,
                "system": self.plant.system.content(),
                "names": self.plant.names,
                "rates": self.plant.rates,
                "initial_state": self.plant.initial_state,
            },
            "at": self.at.tolist(),
            "input": self.input.tolist(),
            "A": self.A.tolist(),
            "B": self.B.tolist(),
            "drift": self.drift.tolist(),
            "is_equilibrium": self.rests,
            "source": self.source,
            "errors": [
                {"within": within, "relative": found.tolist()} for within, found in self.errors
            ],
            "eigenvalues": pairs(self.eigenvalues),
            "controllable": {
                "rank": self.rank,
                "tolerance": TOLERANCE,
                "uncontrollable": pairs(self.uncontrollable),
                "stabilisable": is_stable(self.uncontrollable),
            },
        }

    def sentences(self) -> Iterator[str]:
        """Yield what else there is to say about the model, a line each."""
        way = {
            "derivative": "differences of its derivative",
            "motion": f"the matrix logarithm of its motion over {self.plant.step_ns * 1e-9:g} s",
            "exact": "the plant's own matrices",
        }
        point = f"x = {_shown(self.at)}, u = {_shown(self.input)}"
        yield f"computed from {way[self.source]}, at {point}"
        if not self.rests:
            move, *_ = np.linalg.lstsq(np.hstack([self.A, self.B]), -self.drift, rcond=None)
            x, u = np.split(np.concatenate([self.at, self.input]) + move, [len(self.A)])
            yield (
                f"not an equilibrium: ẋ = {_shown(self.drift)} there; the linear model rests at "
                f"x = {_shown(x)}, u = {_shown(u)}"
            )
        for within, found in self.errors:
            place = int(np.argmax(np.where(np.isnan(found), np.inf, found)))
            yield (
                f"largest relative error within ±{within:g} of the point, sampled: "
                f"{found[place]:.2g} ({self.state_names[place]})"
            )
        if self.is_rough:
            yield "the error does not shrink with the neighbourhood: the plant is not smooth there"
        yield f"eigenvalues: {eigenvalue_text(self.eigenvalues)} /s"
        n, rest = len(self.A), self.uncontrollable
        yield f"controllable: {self.rank} of {n} states (tolerance {TOLERANCE:g})" + (
            "" if self.rank == n else
            f"; not controllable: the eigenvalues {eigenvalue_text(rest)} /s, "
            + ("which are stable" if is_stable(rest) else "so no gain stabilises the plant")
        )  # fmt: skip

    @property
    def is_rough(self) -> bool:
        """Whether the error is as large in the smaller neighbourhood: the plant is not smooth."""
        (_, wide), (_, near) = self.errors or ((0.0, np.zeros(1)), (0.0, np.zeros(1)))
        return bool((near > np.maximum(_ROUGH * wide, _ROUGH_LEAST)).any())

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.plant.names[1] or tuple(f"u_{j}" for j in range(1, self.B.shape[1] + 1))

    def _rows(self) -> Rows:
        both = np.hstack([self.A, self.B])
        return matrix_rows("Â, B̂", both, self.state_names, self.state_names + self.input_names)

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def _shown(vector: Vector) -> str:
    return f"({', '.join(f'{value:.4g}' for value in vector)})"


def matrix_rows(name: str, matrix: Matrix, rows: Sequence[str], columns: Sequence[str]) -> Rows:
    """Return a matrix as rows of text, with the names of rows and columns."""
    entries = ([f"{value:.6g}" for value in row] for row in matrix)
    return [[name, *columns], *([row, *cells] for row, cells in zip(rows, entries, strict=True))]


def sorted_eigenvalues(matrix: Matrix) -> Complex:
    """Return the eigenvalues, the largest real part first."""
    found = np.linalg.eigvals(matrix).astype(np.complex128)
    return found[np.lexsort((found.imag, -found.real))]


def pairs(values: Complex) -> list[list[float]]:
    """Return complex numbers as pairs of real and imaginary part."""
    return [[float(value.real), float(value.imag)] for value in values]


def eigenvalue_text(values: Complex) -> str:
    """Return eigenvalues as text, conjugate pairs as one: "-0.81±0.5j, -5.8"."""
    scale = max(1.0, float(np.abs(values).max(initial=0.0)))
    shown = []
    for value in values:
        if abs(value.imag) <= _REAL * scale:
            shown.append(f"{value.real if abs(value.real) > _REAL**2 * scale else 0.0:.4g}")
        elif value.imag > 0:
            shown.append(f"{value.real:.4g}±{value.imag:.4g}j")
    return ", ".join(shown) or "none"


def is_stable(eigenvalues: Complex) -> bool:
    """Whether all real parts are negative."""
    return bool((eigenvalues.real < 0).all())


def controllable_states(A: Matrix, B: Matrix) -> Matrix:
    """Return an orthonormal basis of the range of the controllability matrix, (n, rank).

    It grows from the range of B by A times the directions found last. A direction counts if it is
    larger than the tolerance times the terms that it is the sum of. So neither the units of the
    states nor fast and slow eigenvalues decide.
    """
    n = len(A)
    basis, new, terms = np.zeros((n, 0)), B, np.abs(B)
    while new.shape[1] and basis.shape[1] < n:
        projection = np.eye(n) - basis @ basis.T
        noise = TOLERANCE * norm(np.linalg.norm(np.abs(projection) @ terms, axis=1))
        directions, sizes, _ = np.linalg.svd(projection @ new, full_matrices=False)
        last = directions[:, sizes > noise]
        basis = np.linalg.qr(np.hstack([basis, last]))[0]
        new, terms = A @ last, np.abs(A) @ np.abs(last)
    return basis


def linear_model(
    plant: str | PlantReference,
    *,
    at: Sequence[float] | None = None,
    held: Sequence[float] | None = None,
    settings: ReadTable | None = None,
    within: float = _HALFWIDTH,
) -> LinearModel:
    """Linearise a plant, or read the file of an earlier linearisation.

    Args:
        plant: as :func:`plant_reference` accepts it, or a file that ``noack linearise`` wrote.
        at: the point x₀; by default 0.
        held: u₀; by default 0.
        settings: values by the keys of a scenario.
        within: half-width of the larger neighbourhood in which the error is sampled.

    Raises:
        CallerError: there is no such plant, it has no linear model there, or a value is wrong.
    """
    if isinstance(plant, str) and plant.endswith(".json"):
        if at is not None or held is not None or settings:
            raise CallerError(f"{plant}: has its point and settings; linearise the plant again")
        return model_from_json(read_document(Path(plant)), plant)
    sizes = (None if at is None else len(at), None if held is None else len(held))
    found = (
        plant
        if isinstance(plant, PlantReference)
        else plant_reference(plant, settings or {}, sizes)
    )
    point, held_at = (
        vector(key, given, size, what)
        for key, given, size, what in (
            ("at", at, found.n, "states"), ("input", held, found.m, "inputs"),
        )
    )  # fmt: skip
    if not (np.isfinite(within) and within > 0):
        raise CallerError(f"within: {within:g}; give a positive number")
    motion, is_exact = _motion(found, point, held_at)
    if motion.void is not None:
        raise CallerError(f"{found.label}: no linear model: {motion.void}")
    A, B = motion.A, motion.B
    if is_exact and found.matrices is not None:
        errors: tuple[tuple[float, Vector], ...] = ()
    else:
        errors = tuple(
            (one, largest_errors(
                found.at, motion, np.full(found.n + found.m, one), at=point, held=held_at,
                settling_s=found.system.settling_s, step_ns=found.step_ns,
            ))
            for one in (within, within / 10)
        )  # fmt: skip
    source = "exact" if is_exact else motion.source
    return LinearModel(found, A, B, point, held_at, motion.drift, source, errors)


def _motion(plant: PlantReference, at: Vector, held: Vector) -> tuple[LinearMotion, bool]:
    """Return the linear model, and whether it is known exactly."""
    exact = plant.matrices or plant.system.linearisation()
    if exact is not None:
        A, B = exact
        return LinearMotion(A, B, product(A, at) + product(B, held), "motion"), True
    with np.errstate(all="ignore"):
        return linearise(
            plant.at, plant.n, plant.m, settling_s=plant.system.settling_s, at=at, held=held,
            step_ns=plant.step_ns,
        ), False  # fmt: skip


def vector(key: str, given: object, size: int, what: str) -> Vector:
    """Return a given vector, (size,); None is 0. Raise CallerError if it is not one."""
    try:
        found = np.zeros(size) if given is None else np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise CallerError(f"{key}: {given!r} is no list of numbers") from None
    if found.shape != (size,):
        raise CallerError(f"{key}: {found.size} numbers; the plant has {size} {what}")
    if not np.isfinite(found).all():
        raise CallerError(f"{key}: {found.tolist()} has entries that are not finite")
    return found


def read_document(path: Path) -> Mapping[str, object]:
    """Return the document of a file that ``noack linearise`` or ``noack gain`` wrote."""
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise CallerError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError:
        document = None
    if not isinstance(document, dict) or document.get("written_by") != WRITTEN_BY:
        raise CallerError(f"{path}: not written by `noack linearise` or `noack gain`")
    return document


def model_from_json(document: Mapping[str, object], label: str) -> LinearModel:
    """Return the model of a document; raise CallerError if it was damaged."""
    try:
        return _model(document)
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        raise CallerError(f"{label}: damaged: {type(error).__name__}: {error}") from None


def _model(document: Mapping[str, object]) -> LinearModel:
    about, errors = document["plant"], document["errors"]
    assert isinstance(about, dict)
    assert isinstance(errors, list)
    A, B, at, held, drift = (
        np.array(document[key], dtype=np.float64) for key in ("A", "B", "at", "input", "drift")
    )
    (n, m), label = B.shape, str(about["label"])
    if A.shape != (n, n) or at.shape != (n,) or held.shape != (m,) or drift.shape != (n,):
        raise ValueError("the shapes of A, B, at, input and drift do not fit")
    if not all(np.isfinite(one).all() for one in (A, B, at, held, drift)):
        raise ValueError("numbers are not finite")
    names = tuple(None if one is None else tuple(map(str, one)) for one in about["names"])
    initial = about["initial_state"]
    reference = PlantReference(
        label, settings_of(about["system"], label), n, m, (names[0], names[1]),
        dict(about["rates"]), None if initial is None else tuple(map(float, initial)),
        (A, B) if about["system"]["kind"] == LinearSettings().kind else None,
    )  # fmt: skip
    within = tuple((float(one["within"]), np.array(one["relative"])) for one in errors)
    return LinearModel(reference, A, B, at, held, drift, str(document["source"]), within)
