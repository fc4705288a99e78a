"""The gain K of u = K x: a linear-quadratic regulator, or given closed-loop eigenvalues."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.studies.new_loop import rounded
from cosim.studies.new_loop.linear_model import (
    Complex,
    LinearModel,
    eigenvalue_text,
    is_stable,
    matrix_rows,
    model_from_json,
    pairs,
    read_document,
    sorted_eigenvalues,
)
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.core.number_format import Rows, as_html, as_text
from noack.scenario.sections import instability
from noack.settings.section import Table

GAIN = "gain"
Weights = float | Sequence[float]
"""The diagonal of a weight; one number is all its entries."""
_IMAGINARY = 1e-9
_DIGITS = 10


@dataclass(frozen=True)
class LoopGain:
    """A linear model with a gain: ``K``, (m, n), of u = K x, and the ``eigenvalues`` of Â + B̂K."""

    model: LinearModel
    K: Matrix
    method: str
    """How K was computed, as text."""

    @property
    def eigenvalues(self) -> Complex:
        """Eigenvalues of Â + B̂K, per second, the largest real part first."""
        return sorted_eigenvalues(self.model.A + self.model.B @ self.K)

    @property
    def decay_per_s(self) -> float:
        """The decay rate of Â + B̂K: the trigger's α must be below it."""
        return -float(self.eigenvalues[0].real)

    def to_json(self) -> Table:
        """Return the document of ``noack gain --json``: that of the model, and the gain."""
        return self.model.to_json() | {
            GAIN: self.K.tolist(),
            "method": self.method,
            "closed_loop_eigenvalues": pairs(self.eigenvalues),
            "alpha_below_per_s": self.decay_per_s,
        }

    def sentences(self) -> Iterator[str]:
        """Yield what else there is to say about the gain, a line each."""
        yield f"u = K x; {self.method}"
        yield f"eigenvalues of Â + B̂K: {eigenvalue_text(self.eigenvalues)} /s"
        yield (
            f"the trigger's alpha_per_s must be below {self.decay_per_s:.4g}, the decay rate; half "
            "of it is usual"
        )

    def _rows(self) -> Rows:
        return matrix_rows("K", self.K, self.model.input_names, self.model.state_names)

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def loop_gain(
    model: LinearModel,
    *,
    q: Weights | None = None,
    r: Weights | None = None,
    poles: Sequence[complex] | None = None,
) -> LoopGain:
    """Compute K for a model: the linear-quadratic regulator, or the given eigenvalues.

    Args:
        model: the linear model.
        q: weight of the states in ∫ xᵀQx + uᵀRu dt: one number, or the diagonal; by default 1.
        r: weight of the inputs, likewise.
        poles: the eigenvalues of the controllable part of Â + B̂K instead, per second.

    Raises:
        CallerError: an unstable eigenvalue is not controllable, or the values do not fit.
    """
    if not is_stable(model.uncontrollable):
        worst = eigenvalue_text(model.uncontrollable[:1])
        raise CallerError(
            f"{model.plant.label}: no gain stabilises it: the eigenvalue {worst} /s is not "
            "controllable"
        )
    if poles is not None:
        if q is not None or r is not None:
            raise CallerError("poles: give either these or the weights q and r")
        K, method = (
            _placed(model, poles),
            f"poles {eigenvalue_text(np.array(poles, np.complex128))}",
        )
    else:
        n, m = model.B.shape
        Q, R = _diagonal("q", q, n, "states", 0.0), _diagonal("r", r, m, "inputs", None)
        K = _regulator(model, Q, R)
        method = f"linear-quadratic regulator, Q = {_diagonal_text(Q)}, R = {_diagonal_text(R)}"
    K = np.array([[rounded(value, _DIGITS) for value in row] for row in K])
    if (why := instability(model.A, model.B, K)) is not None:
        raise CallerError(f"{model.plant.label}: {why}")
    return LoopGain(model, K, method)


def _regulator(model: LinearModel, Q: Matrix, R: Matrix) -> Matrix:
    from scipy.linalg import solve_continuous_are  # importing scipy takes 0.2 s

    try:
        P = solve_continuous_are(model.A, model.B, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise CallerError(f"{model.plant.label}: no linear-quadratic regulator: {error}") from None
    return np.asarray(-np.linalg.solve(R, model.B.T @ P), dtype=np.float64)


def _placed(model: LinearModel, poles: Sequence[complex]) -> Matrix:
    """Return K that places the eigenvalues of the controllable part."""
    from scipy.signal import place_poles  # importing scipy takes 0.2 s

    wanted, basis = np.array(poles, dtype=np.complex128), model.controllable
    if not np.isfinite(wanted).all() or (wanted.real >= 0).any():
        raise CallerError("poles: they need negative real parts, e.g. -1,-2+1j,-2-1j")
    if len(wanted) != model.rank:
        raise CallerError(
            f"poles: {len(wanted)} given; the controllable part has {model.rank} eigenvalues"
        )
    if np.abs(np.sort_complex(wanted) - np.sort_complex(wanted.conj())).max() > _IMAGINARY:
        raise CallerError("poles: complex ones are needed in conjugate pairs, -2+1j and -2-1j")
    if np.unique(wanted, return_counts=True)[1].max() > np.linalg.matrix_rank(model.B):
        raise CallerError(
            "poles: a pole may occur as often as there are inputs; take distinct ones"
        )
    real = wanted.real if not wanted.imag.any() else wanted
    try:
        placed = place_poles(basis.T @ model.A @ basis, basis.T @ model.B, real)
    except ValueError as error:
        raise CallerError(f"poles: {error}") from None
    return -np.asarray(placed.gain_matrix) @ basis.T


def _diagonal(key: str, given: Weights | None, size: int, what: str, least: float | None) -> Matrix:
    """Return a diagonal weight; ``least`` is its smallest allowed entry, None: it is positive."""
    values = np.atleast_1d(np.array(1.0 if given is None else given, dtype=np.float64))
    if len(values) not in (1, size):
        raise CallerError(
            f"{key}: {len(values)} numbers; give 1 or {size}, one per entry of {what}"
        )
    if not np.isfinite(values).all() or (values <= 0 if least is None else values < least).any():
        raise CallerError(f"{key}: {values.tolist()}; the weights need to be " + (
            "positive" if least is None else "0 or more"))  # fmt: skip
    return np.diag(np.full(size, values))


def _diagonal_text(matrix: Matrix) -> str:
    values = np.diag(matrix)
    if (values == values[0]).all():
        return f"{values[0]:g} I"
    return f"diag({', '.join(f'{value:g}' for value in values)})"


def read_gain(path: str) -> LinearModel | LoopGain:
    """Return the model, or the model with its gain, of a file; raise CallerError if damaged."""
    document = read_document(Path(path))
    model = model_from_json(document, path)
    if GAIN not in document:
        return model
    try:
        K = np.array(document[GAIN], dtype=np.float64)
        if K.shape != model.B.T.shape or not math.isfinite(K.sum()):
            raise ValueError("gain does not fit B")
    except (TypeError, ValueError) as error:
        raise CallerError(f"{path}: damaged: {error}") from None
    return LoopGain(model, K, str(document["method"]))
