"""Robust certificates: bounds that hold for every plant of an uncertainty box around the model.

Let A = Â + Ã and B = B̂ + B̃, with each entry of |Ã| and |B̃| at most the box's half-width. With
u = K x + p, the plant is the model with the model error w = Ã x + B̃ u as an additional input:

    x' = (Â + B̂K) x + B̂ p + w

Each |w_i| is bounded by the half-widths and the suprema of the coordinates. Each coordinate is
bounded by the peak gains (∫ of impulse responses) of the model's closed loop. The result is a
linear inequality between non-negative numbers. If the spectral radius of its matrix is below 1, its
solution holds for all plants of the box, including time-varying ones.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector
from noack.core.number_format import apart_from
from noack.theory.bounds.contraction import logarithmic_norm
from noack.theory.bounds.enclosure import NotDecayingError, Outputs, ResponseBounds, response
from noack.theory.bounds.gains import Coefficients, Columns, Output, PlantGains
from noack.theory.bounds.stacked_norms import spectral_norm


@dataclass(frozen=True)
class BoxGains(PlantGains):
    """Gains that hold for all plants of a box around A and B; half-widths (n, n) and (n, m)."""

    halfwidth_A: Matrix
    halfwidth_B: Matrix

    is_one_plant: ClassVar = False

    @cached_property
    def states(self) -> Mapping[str, Coefficients]:
        """sup‖C x‖ from x(0), disturbances and input error; w is added to ``MISMATCH``.

        Raises:
            NotDecayingError: the model decays too slowly, or the box is too large.
        """
        free, gain = self._free_model_error, self._forced_model_error
        states = {
            output: Coefficients(
                self._from_start[output] + free @ peaks.from_w, peaks.forced + gain @ peaks.from_w
            )
            for output, peaks in self._peaks.items()
        }
        nominal = states[Output.MISMATCH]
        # sup‖(R_E x, S w)‖ ≤ sup‖R_E x‖ + sup‖S w‖
        states[Output.MISMATCH] = Coefficients(
            nominal.free + np.linalg.norm(self._scales * free, axis=-1),
            nominal.gain + np.linalg.norm(self._scales * gain, axis=-1),
        )
        return states

    @cached_method
    def start_up(self, start_s: float) -> tuple[Vector, Mapping[str, Vector]]:
        """Return the effect of zero input before ``start_s``: p = −K x, x' = A x for every A.

        With zero input w = Ã x, and B̃ times its disturbance, which the bound of w covers.
        """
        if start_s == 0:
            return np.zeros(()), dict.fromkeys(self.outputs, np.zeros(()))
        error, impulse, w = self._start_bounds(start_s)
        states = {output: impulse * peaks.impulse + w @ peaks.from_w for output, peaks in self._peaks.items()}
        states[Output.MISMATCH] += np.linalg.norm(self._scales * w, axis=-1)
        return error, states

    def _start_bounds(self, start_s: float) -> tuple[Vector, Vector, Vector]:
        """Return sup‖p‖ over the start, ∫‖p‖, and the bound of |w| that follows."""
        R, box = self.error.split_K[1], spectral_norm(self.halfwidth_A)
        # ‖e^{As}‖ ≤ e^{μs}; the logarithmic norm μ of a sum is at most the sum of both norms.
        mu = max(float(logarithmic_norm(self.A) + box), 0.0) + self.alpha_per_s
        # A disturbance of the input enters through B̂, and through B̃.
        limited, added = self._forcing.limited, self.halfwidth_B @ self._forcing.at_input
        entering = np.linalg.norm(limited, axis=0).sum() + np.linalg.norm(added)
        size = spectral_norm(self.start) + start_s * entering
        size = size * math.exp(mu * start_s)
        rate = spectral_norm(R @ self.A) + spectral_norm(R) * box
        at_start = spectral_norm(R @ self.start) * math.exp(self.alpha_per_s * start_s)
        entering = np.linalg.norm(R @ limited, axis=0).sum() + np.linalg.norm(np.abs(R) @ added)
        error = at_start + start_s * (rate * size + entering)
        impulse = error * start_s
        peaks_of = np.array([peaks.impulse for peaks in self._coordinates])
        return error, impulse, self._bound_of_w(impulse[..., None] * peaks_of)

    def coordinate_bounds(self, input_error: float, start_s: float) -> Vector:
        """Bound each |x_j|, and each |u_i| with its disturbance, scaled, (n + m,).

        ``input_error``: sup‖u − K x‖. Before ``start_s`` the input is 0.
        """
        n, from_start = len(self.A), self._from_start.items()
        total = np.stack([bound for name, bound in from_start if name not in self.outputs], axis=-1)
        w, impulse = self._free_model_error + self._forced_model_error * input_error, np.zeros(())
        if start_s > 0:
            _, impulse, late = self._start_bounds(start_s)
            w = w + late
        for index, peaks in enumerate(self._coordinates):
            total[index] += peaks.forced * input_error + peaks.impulse * impulse + peaks.from_w @ w
        total[n:] += np.linalg.norm(self.error.split_K[0], axis=1) * input_error
        total[n:] += self._forcing.at_input
        return np.asarray(total)

    @property
    def columns(self) -> Columns:
        """The columns through which e_s is driven; the model error is added to the mismatch."""
        nominal, R = self.split_mismatch
        # If H is the closed loop of the box's centre, there is no nominal mismatch.
        differs = R.any() or not self._rows
        pushed = self._directions / self._scales
        forced = np.concatenate([nominal, pushed], axis=1) if differs else pushed
        return super().columns._replace(mismatch=forced)

    @cached_property
    def _rows(self) -> list[int]:
        """Rows of A and B that are uncertain."""
        uncertain = np.concatenate([self.halfwidth_A, self.halfwidth_B], axis=1).any(axis=1)
        return [int(i) for i in np.flatnonzero(uncertain)]

    @cached_property
    def _directions(self) -> Matrix:
        """The unit vectors of the entries of w that are not 0."""
        return np.eye(len(self.A))[:, self._rows]

    @cached_property
    def _scales(self) -> Vector:
        """S: ‖·‖_W of these unit vectors, by which w is scaled where it drives e_s."""
        return np.asarray(np.linalg.norm(self.error.weight @ self._directions, axis=0))

    @cached_property
    def _from_start(self) -> Mapping[str, Vector]:
        """sup‖C x‖ from x(0) and the disturbances, of every output and every coordinate."""
        started = response(self.closed_loop, self.start).through_each(self._stacked_signals)
        return {name: started[name].sup() + self.disturbed(C) for name, C in self._signals.items()}

    @cached_property
    def _signals(self) -> Mapping[str, Matrix]:
        """The outputs, and the coordinates of x and of K x."""
        rows = np.concatenate([np.eye(len(self.A)), self.error.K])
        names = (f"coordinate {index}" for index in range(len(rows)))
        return {**self.outputs, **dict(zip(names, rows[:, None], strict=True))}

    @cached_property
    def _stacked_signals(self) -> Outputs[str]:
        return Outputs(self._signals)

    @cached_property
    def _responses_to_errors(self) -> list[ResponseBounds]:
        """Responses of the model's closed loop to each w_i."""
        return [response(self.closed_loop, column[:, None]) for column in self._directions.T]

    def _peaks_at(self, C: Matrix) -> "_PeakGains":
        forced = self._forced.through(C)
        from_w = [float(w.through(C).integral()) for w in self._responses_to_errors]
        return _PeakGains(float(forced.integral()), float(forced.sup()), np.array(from_w))

    @cached_property
    def _peaks(self) -> Mapping[str, "_PeakGains"]:
        return {output: self._peaks_at(C) for output, C in self.outputs.items()}

    @cached_property
    def _coordinates(self) -> list["_PeakGains"]:
        """Peak gains of each coordinate of x and of K x."""
        return [self._peaks_at(C) for name, C in self._signals.items() if name not in self.outputs]

    @cached_property
    def _halfwidths(self) -> Matrix:
        """Half-widths Δ with |w| ≤ Δ |(x, u)|."""
        return np.concatenate([self.halfwidth_A, self.halfwidth_B], axis=1)[self._rows]

    def _bound_of_w(self, coordinates: Vector) -> Vector:
        """Return sup|w|, (…, rows), from bounds of |(x, K x)| that were computed without w."""
        from_w = np.array([peaks.from_w for peaks in self._coordinates])
        loop = self._halfwidths @ from_w
        gain = float(np.abs(np.linalg.eigvals(loop)).max(initial=0.0))
        if not gain < 1:
            raise NotDecayingError(
                "the plants differ too much from the model: the loop gain of what differs is "
                f"{apart_from(1, gain)}, not below 1"
            )
        known = (coordinates @ self._halfwidths.T)[..., None]
        return np.asarray(np.linalg.solve(np.eye(len(loop)) - loop, known)[..., 0])

    @cached_property
    def _free_model_error(self) -> Vector:
        """sup|w_i| without an input error; with one, sup‖p‖ times the forced error is added."""
        from_start = self._from_start.items()
        bounds = [bound for name, bound in from_start if name not in self.outputs]
        start = np.stack(bounds, axis=-1)
        start[..., len(self.A) :] += self._forcing.at_input  # B̃ acts on u with its disturbance
        return self._bound_of_w(start)

    @cached_property
    def _forced_model_error(self) -> Vector:
        forced = np.array([peaks.forced for peaks in self._coordinates])
        forced[len(self.A) :] += np.linalg.norm(self.error.split_K[0], axis=1)  # u = K x + p
        return self._bound_of_w(forced)


class _PeakGains(NamedTuple):
    """sup‖C x‖ ≤ forced · sup‖p‖ + impulse · ∫‖p‖ + from_w · |w| + what x(0) gives."""

    forced: float
    impulse: float
    from_w: Vector
