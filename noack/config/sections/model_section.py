"""The model of the plant that sensor and controller use."""

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from noack.config.named_models import MODEL_PARAMETERS, NAMED_MODELS
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.settings.matrices import Rows, require_length, require_shape, shape
from noack.settings.section import ScenarioSection


class ModelSection(ScenarioSection):
    """The model that sensor and controller use: Â, B̂, and the gain K of u = K x_c.

    It is given by ``name`` (with optional ``parameters``), by the matrices ``A``, ``B`` and
    ``gain``, or by a ``file`` with these matrices.
    """

    name: Literal["lane_following", "single_track_lane", "double_integrator"] | None = None
    """A named model; see noack/config/named_models.py."""
    parameters: dict[str, FiniteFloat] = Field({})
    """Parameters of the named model that differ from its defaults."""
    A: Rows | None = None
    """Â by rows, n x n, per second."""
    B: Rows | None = None
    """B̂ by rows, n x m."""
    gain: Rows | None = None
    """K by rows, m x n; a named model has its own gain, and a file may have one."""
    file: str | None = None
    """An .npz or .mat file with A, B and, unless it is given here, the gain, named gain or K. A
    relative name is relative to the scenario file. Loading the scenario replaces the name by the
    matrices."""
    names: dict[Literal["A", "B", "gain"], str] | None = None
    """Names of the arrays in the file, if they differ from A, B and gain."""
    state_names: tuple[str, ...] | None = None
    """Names of the n states, for plots."""
    input_names: tuple[str, ...] | None = None
    """Names of the m inputs, for plots."""
    allow_unstable: bool = False
    """Accept a gain with which the model's closed loop Â + B̂K is unstable."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_read(self.file, self.names)
        if self.name is not None:
            self._check_named(self.name)
        else:
            self._check_explicit()
        n, m = self.dimensions
        require_shape(self.gain, "gain", (m, n), "one row per input, one column per state")
        require_length(self.state_names, "state_names", n, "one name per state")
        require_length(self.input_names, "input_names", m, "one name per input")
        self._require_stable()
        return self

    def _require_stable(self) -> None:
        (A, B), own = self.matrices, self.gain is None  # a named model's own gain
        K = NAMED_MODELS[self.name or ""](self.parameters).K if own else np.array(self.gain)
        key = "parameters" if own else "gain"
        if not np.isfinite(_closed_loop(A, B, K)).all():
            raise ValueError(f"{key}: A + BK has infinite entries; check the units of A, B and K")
        if not self.allow_unstable and (why := instability(A, B, K)) is not None:
            raise ValueError(
                f"{key}: {why}; to run the unstable loop anyway, set model.allow_unstable = true"
            )

    def _check_named(self, name: str) -> None:
        if self.A is not None or self.B is not None:
            raise ValueError("name: a named model has its own A and B; give one or the other")
        known = MODEL_PARAMETERS[name]
        for key in self.parameters:
            if key not in known:
                raise ValueError(
                    f"parameters.{key}: {name} has no such parameter; it has {', '.join(known)}"
                )
        named = NAMED_MODELS[name](self.parameters)
        if not all(np.isfinite(matrix).all() for matrix in (named.A, named.B, named.K)):
            raise ValueError("parameters: these give matrices with infinite entries")

    def _check_explicit(self) -> None:
        if self.parameters:
            raise ValueError("parameters: only a named model has parameters")
        if self.A is None or self.B is None or self.gain is None:
            missing = [k for k in ("A", "B", "gain") if getattr(self, k) is None]
            raise ValueError(
                f"{missing[0]}: give a model by name, or by the matrices A, B and gain, or by a "
                f"file of them (missing: {', '.join(missing)})"
            )
        n = len(self.A)
        require_shape(self.A, "A", (n, n), "the system matrix is square")
        height, width = shape(self.B, "B")
        m = height if width == n != height else width  # it may be transposed
        require_shape(self.B, "B", (n, m), "one row per state")

    @property
    def dimensions(self) -> tuple[int, int]:
        """Number of states n and of inputs m."""
        if self.name is not None:
            n, m = NAMED_MODELS[self.name](self.parameters).B.shape
            return n, m
        return (len(self.B), len(self.B[0])) if self.B else (0, 0)

    @property
    def matrices(self) -> tuple[Matrix, Matrix]:
        """Â, (n, n), and B̂, (n, m)."""
        if self.name is not None:
            named = NAMED_MODELS[self.name](self.parameters)
            return named.A, named.B
        return np.array(self.A), np.array(self.B)


def require_read(file: str | None, names: Mapping[Any, str] | None) -> None:
    """Raise ValueError if a section still names a file: loading a scenario replaces the name."""
    if file is not None:
        raise ValueError("file: it is read where a scenario file is loaded; give matrices here")
    if names is not None:
        raise ValueError("names: they are of arrays in a file; give file, too")


def instability(A: Matrix, B: Matrix, K: Matrix) -> str | None:
    """Return why u = K x does not stabilise ẋ = A x + B u, with a remedy; None if it does."""
    loops = (_closed_loop(A, B, K), _closed_loop(A, B, -K))
    growth_per_s, opposite_per_s = (
        spectral_abscissa(loop) if np.isfinite(loop).all() else np.inf for loop in loops
    )
    if growth_per_s < 0:
        return None
    remedy = (
        "u = -K x does: give -K (python-control and Matlab return the K of u = -K x)"
        if opposite_per_s < 0
        else "give a gain for which all eigenvalues of A + BK have negative real parts"
    )
    return (
        "u = K x does not stabilise the model: A + BK has an eigenvalue with real part "
        f"{growth_per_s:.3g} /s; {remedy}"
    )


def _closed_loop(A: Matrix, B: Matrix, K: Matrix) -> Matrix:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(A + B @ K)
