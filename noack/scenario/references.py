"""From pieces of a reference to the segments of x_r(t) and u_r(t) that the machines follow.

An output y = c x follows a piece: a polynomial or a sine wave r(t). The regulator equations
(Francis, *SIAM J. Control Optim.* 15, 1977) give the solution of the model with this output:

    ẋ_r = Â x_r + B̂ u_r,   C x_r = r.

For polynomials and waves they are linear equations of the coefficients. Where one piece follows
another x_r may jump: sensor and controller know when.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from netem.core.clock import NS_PER_S
from noack.controllers.state_space import StateSpaceSettings
from noack.core.linear_systems import Matrix, Vector
from noack.core.references import ReferenceSegment
from noack.references.file import FilePiece
from noack.references.piece_settings import OutputPiece, OutputSignal, PieceSettings, joining
from noack.references.segment import SolutionSegment
from noack.scenario.controller_states import controlled_model
from noack.scenario.scenario_tables import ScenarioTables

_ROUNDING = 1e-9
"""Largest residual of the regulator equations that is rounding, relative to their terms."""
_SAMPLES = 50
"""Times at which a given segment is compared with the model."""
_NEGLIGIBLE = 1e-15
"""Numbers of a solution that are 0 but for rounding, as a share of its largest one."""
_MOST_DERIVATIVES = 4
"""Largest number of derivatives with which a joined piece continues the one before."""

Timeline = Sequence[tuple[int, OutputSignal]]
"""The signals of an output, and when each begins, in nanoseconds; the first one begins at 0."""


class PieceError(ValueError):
    """A piece is wrong; ``place`` is its number from 0."""

    def __init__(self, place: int, message: str) -> None:
        super().__init__(message)
        self.place = place


def scenario_segments(scenario: ScenarioTables) -> list[ReferenceSegment] | None:
    """Return the segments of a scenario's reference, without loads; None if it has none.

    They are those of a set-point, too, if the controller has states: these are not at rest there.

    Raises:
        PieceError: a piece is wrong, or the model cannot follow it.
    """
    controller, given = scenario.controller, scenario.model
    pieces, model = controller.reference, given
    if isinstance(controller, StateSpaceSettings):  # a resolved model has these states in its matrices
        model = controlled_model(given, controller)
    (A, B), n, own = model.matrices, model.followed_states, given.plant_states
    A, B = A[:n, :n], B[:n]
    if pieces is None:
        if not controller.states or not any(controller.setpoint or ()):
            return None
        signals = [OutputSignal(np.array([value])) for value in controller.setpoint or ()]
        return [_solution(A, B, np.eye(own, n), signals, 0, 1.0, np.zeros(n))]
    if n > own and isinstance(pieces[0], FilePiece):
        raise PieceError(0, "kind: a file has no states of the controller; give steps, ramps or sines")
    states, _ = scenario.entry_names
    rows = dict(zip(states[:own], np.eye(own, n), strict=True))
    for output in scenario.loop_outputs():
        rows[output.name] = np.pad(np.array(output.row)[:n], (0, max(n - len(output.row), 0)))
    return reference_segments(pieces, A, B, rows, scenario.horizon_s)


def reference_segments(
    pieces: Sequence[PieceSettings], A: Matrix, B: Matrix, rows: Mapping[str, Vector], horizon_s: float
) -> list[ReferenceSegment]:
    """Return the segments of a reference.

    Args:
        pieces: at least one; that of a file which has not been read has no segments.
        A: Â, (n, n).
        B: B̂, (n, m).
        rows: c of each output y = c x, (n,), by its name; the first n are the states.
        horizon_s: length of the run.

    Raises:
        PieceError: a piece is wrong, or the model cannot follow it.
    """
    first = pieces[0]
    others = [piece.kind for piece in pieces if piece.kind != first.kind]
    if others and not all(isinstance(piece, OutputPiece) for piece in pieces):
        raise PieceError(0, f"kind: {first.kind} and {others[0]} do not go together")
    if isinstance(first, FilePiece):
        return _of_file(pieces, first, A, B, horizon_s, [*rows][: len(A)])
    if isinstance(first, SolutionSegment):
        return _given_segments(pieces, A, B, horizon_s)
    timelines = _timelines(pieces, rows, A, B)
    C = np.array([rows[output] for output in timelines])
    places = _places(pieces)
    segments = _solved(list(timelines.values()), A, B, C, places)
    if (failed := _inexact_segment(segments, A, B, horizon_s)) is not None:
        begin_ns = segments[failed].begin_ns
        place = [place for since_ns, place in places if since_ns <= begin_ns][-1]
        raise PieceError(
            place, "join_s: too short for a solution of the model that is exact; take a longer one"
        )
    return segments


def _of_file(
    pieces: Sequence[PieceSettings], piece: FilePiece, A: Matrix, B: Matrix, horizon_s: float,
    states: Sequence[str],
) -> list[ReferenceSegment]:  # fmt: skip
    if len(pieces) > 1:
        raise PieceError(1, "kind: one file is a whole reference")
    if piece.file is not None:
        return []  # its numbers are checked when it has been read
    try:
        piece.check(A, B, horizon_s, states)
    except ValueError as error:
        raise PieceError(0, str(error)) from None
    return piece.segments(A, B)


def _given_segments(
    pieces: Sequence[PieceSettings], A: Matrix, B: Matrix, horizon_s: float
) -> list[ReferenceSegment]:
    """Return given segments; refuse those that are not in order, or not solutions of the model."""
    end_ns, segments = -1, list[ReferenceSegment]()
    for place, piece in enumerate(pieces):
        assert isinstance(piece, SolutionSegment)
        try:
            piece.check(*B.shape)
        except ValueError as error:
            raise PieceError(place, str(error)) from None
        segment = piece.numbers
        if segment.begin_ns <= end_ns or (place == 0 and segment.begin_ns):
            raise PieceError(place, "from_s: the first segment begins at 0, each other one later")
        end_ns = segment.begin_ns
        segments.append(segment)
    if (failed := _inexact_segment(segments, A, B, horizon_s)) is not None:
        raise PieceError(failed, "x: not a solution of the model, ẋ_r = Âx_r + B̂u_r")
    return segments


def _inexact_segment(
    segments: Sequence[ReferenceSegment], A: Matrix, B: Matrix, horizon_s: float
) -> int | None:
    """Return the number of a segment that is no solution of the model until the next one; None: all are."""
    ends_ns = [*(segment.begin_ns for segment in segments[1:]), _ns(horizon_s)]
    for number, (segment, end_ns) in enumerate(zip(segments, ends_ns, strict=True)):
        if not _is_solution(segment, max(end_ns - segment.begin_ns, 0) * 1e-9, A, B):
            return number
    return None


def _is_solution(segment: ReferenceSegment, length_s: float, A: Matrix, B: Matrix) -> bool:
    """Whether ẋ_r − Âx_r − B̂u_r is rounding at sampled times of a segment."""
    n, AB, omega = len(A), np.hstack([A, B]), 2 * math.pi * segment.hz[:, None]
    powers = np.arange(1, len(segment.polynomial))[:, None]
    slope = ReferenceSegment(
        0, np.vstack([powers * segment.polynomial[1:], 0 * segment.polynomial[:1]]),
        segment.hz, -omega * segment.cosines, omega * segment.sines,
    )  # fmt: skip
    times_s = np.linspace(0.0, length_s, _SAMPLES)
    rows, slopes = (np.array([part.at(t_s) for t_s in times_s]) for part in (segment, slope))
    residuals = np.abs(rows @ AB.T - slopes[:, :n])
    terms = np.abs(rows) @ np.abs(AB).T + np.abs(slopes[:, :n])
    return bool((residuals <= _ROUNDING * terms.max()).all())


def _places(pieces: Sequence[PieceSettings]) -> list[tuple[int, int]]:
    """Return when each piece begins, in nanoseconds, and its number; in the order of time."""
    return sorted((_ns(p.from_s), place) for place, p in enumerate(pieces) if isinstance(p, OutputPiece))


def _ns(t_s: float) -> int:
    return round(t_s * NS_PER_S)


def _timelines(
    pieces: Sequence[PieceSettings], rows: Mapping[str, Vector], A: Matrix, B: Matrix
) -> Mapping[str, Timeline]:
    """Return the signals of each output that has pieces; a shorter run does not reach the last ones."""
    outputs: dict[str, list[tuple[int, OutputPiece]]] = {}
    for place, piece in enumerate(pieces):
        assert isinstance(piece, OutputPiece)
        if piece.output not in rows:
            raise PieceError(
                place, f"output: {piece.output!r} is no output or state; these are {', '.join(rows)}"
            )
        outputs.setdefault(piece.output, []).append((place, piece))
    return {
        output: _timeline(of_output, 1 + _relative_degree(A, B, rows[output]))
        for output, of_output in outputs.items()
    }


def _relative_degree(A: Matrix, B: Matrix, row: Vector) -> int:
    """Return the first derivative of an output that depends on the input, or the largest that is used.

    Where the plant has no zeros, x_r and u_r are continuous if the output is so up to this derivative.
    """
    for degree in range(1, min(len(A), _MOST_DERIVATIVES)):
        if np.abs(row @ B).max() > _ROUNDING * np.abs(row).max() * np.abs(B).max():
            return degree
        row = row @ A
    return min(len(A), _MOST_DERIVATIVES)


def _timeline(pieces: Sequence[tuple[int, OutputPiece]], derivatives: int) -> Timeline:
    """Return the signals of an output; a joined piece continues this number of derivatives."""
    timeline: list[tuple[int, OutputSignal]] = [(0, OutputSignal(np.zeros(1)))]
    ends = [*(piece.from_s for _, piece in pieces[1:]), math.inf]
    before_s, free_s = -1.0, 0.0
    for (place, piece), next_s in zip(pieces, ends, strict=True):
        end_s = next_s if piece.until_s is None else piece.until_s
        if piece.from_s <= before_s or piece.from_s < free_s:
            earlier = f"begins at {before_s:g} s" if piece.from_s <= before_s else f"ends at {free_s:g} s"
            raise PieceError(place, f"from_s: the piece of {piece.output} before it {earlier}")
        if piece.until_s is not None and piece.until_s <= piece.from_s:
            raise PieceError(place, f"until_s: not after its begin at {piece.from_s:g} s")
        if piece.join_s > end_s - piece.from_s:
            raise PieceError(place, f"join_s: longer than the piece, {end_s - piece.from_s:g} s")
        begin_ns, join_ns = _ns(piece.from_s), _ns(piece.join_s)
        since_ns, before = timeline[-1]
        start = before.derivatives((begin_ns - since_ns) * 1e-9, derivatives)
        signal = piece.signal(float(start[0]))
        if join_ns:
            duration_s = join_ns * 1e-9
            join = joining(start, signal.derivatives(duration_s, derivatives), duration_s)
            timeline += [(begin_ns, join), (begin_ns + join_ns, signal.from_time(duration_s))]
        else:
            timeline.append((begin_ns, signal))
        if piece.until_s is not None and piece.until_s < next_s:
            end_ns = _ns(piece.until_s)
            value = signal.derivatives((end_ns - begin_ns) * 1e-9, 1)
            timeline.append((end_ns, OutputSignal(value)))
        before_s, free_s = piece.from_s, max(free_s, piece.until_s or 0.0)
    return timeline


def _solved(
    timelines: Sequence[Timeline], A: Matrix, B: Matrix, C: Matrix, places: Sequence[tuple[int, int]]
) -> list[ReferenceSegment]:
    """Return the solution of the model over each interval in which no output changes its signal."""
    begins_ns = sorted({begin_ns for timeline in timelines for begin_ns, _ in timeline})
    segments: list[ReferenceSegment] = []
    near = np.zeros(len(A))
    for begin_ns, end_ns in zip(begins_ns, [*begins_ns[1:], None], strict=True):
        signals = [_signal_at(timeline, begin_ns) for timeline in timelines]
        length_s = 1.0 if end_ns is None else (end_ns - begin_ns) * 1e-9
        try:
            segment = _solution(A, B, C, signals, begin_ns, length_s, near)
        except ValueError as error:
            place = [place for since_ns, place in places if since_ns <= begin_ns][-1]
            raise PieceError(place, str(error)) from None
        segments.append(segment)
        if end_ns is not None:
            near = segment.at(length_s)[: len(A)]
    return segments


def _signal_at(timeline: Timeline, t_ns: int) -> OutputSignal:
    """Return the signal in force at a time; τ is the time since then."""
    begin_ns, signal = [entry for entry in timeline if entry[0] <= t_ns][-1]
    return signal if begin_ns == t_ns else signal.from_time((t_ns - begin_ns) * 1e-9)


def _solution(
    A: Matrix,
    B: Matrix,
    C: Matrix,
    signals: Sequence[OutputSignal],
    begin_ns: int,
    length_s: float,
    near: Vector,
) -> ReferenceSegment:
    """Solve the regulator equations for signals of the outputs C x, (q, n).

    Where they leave x_r free, it begins near ``near``, (n,). Raise ValueError if the model cannot
    follow the signals.
    """
    frequencies, waves = sorted({signal.hz for signal in signals if signal.hz}), []
    for hz in frequencies:
        outputs = np.array([(s.sine, s.cosine) if s.hz == hz else (0.0, 0.0) for s in signals])
        waves.append(_wave_solution(A, B, C, hz, outputs))
    n, m = B.shape
    sines, cosines = (np.array([wave[k] for wave in waves]).reshape(-1, n + m) for k in (0, 1))
    start = near - cosines[:, :n].sum(axis=0)
    polynomial = _polynomial_solution(A, B, C, [signal.polynomial for signal in signals], length_s, start)
    return ReferenceSegment(begin_ns, polynomial, np.array(frequencies), sines, cosines)


def _polynomial_solution(
    A: Matrix, B: Matrix, C: Matrix, outputs: Sequence[Vector], length_s: float, near: Vector
) -> Matrix:
    """Return the coefficients of 1, τ, τ² …, (powers, n + m).

    (k + 1) x_{k+1} = Â x_k + B̂ u_k and C x_k = r_k. Where the model integrates an output, its
    solution has a higher degree than the output: at a constant speed the position is a ramp.
    """
    (n, m), q = B.shape, len(C)
    degree = max(map(len, outputs)) - 1
    wanted = np.zeros((degree + n + 1, q))
    for place, output in enumerate(outputs):
        wanted[: len(output), place] = output * length_s ** np.arange(len(output))
    if not wanted.any() and not near.any():
        return np.zeros((1, n + m))
    for powers in range(degree + 1, degree + n + 2):
        M = np.zeros((powers, n + q, powers, n + m))
        for k in range(powers):
            M[k, :n, k, :n], M[k, :n, k, n:], M[k, n:, k, :n] = A * length_s, B * length_s, C
            if k + 1 < powers:
                M[k, :n, k + 1, :n] = -(k + 1) * np.eye(n)
        rhs = np.zeros((powers, n + q))
        rhs[:, n:] = wanted[:powers]
        start = np.zeros((powers, n + m))
        start[0, :n] = near
        solution = _solve(M.reshape(powers * (n + q), -1), rhs.ravel(), start.ravel())
        if solution is not None:
            return np.asarray(solution.reshape(powers, n + m) / length_s ** np.arange(powers)[:, None])
    raise ValueError(f"output: {_NO_SOLUTION}")


def _wave_solution(A: Matrix, B: Matrix, C: Matrix, hz: float, outputs: Matrix) -> Matrix:
    """Return the factors of sine and cosine, (2, n + m), for those of the outputs, (q, 2)."""
    (n, m), q, omega = B.shape, len(C), 2 * math.pi * hz
    M = np.zeros((2, n + q, 2, n + m))
    for k in (0, 1):
        M[k, :n, k, :n], M[k, :n, k, n:], M[k, n:, k, :n] = A / omega, B / omega, C
    M[0, :n, 1, :n], M[1, :n, 0, :n] = np.eye(n), -np.eye(n)  # −ωx_c = Âx_s + …, ωx_s = Âx_c + …
    rhs = np.zeros((2, n + q))
    rhs[:, n:] = outputs.T
    solution = _solve(M.reshape(2 * (n + q), -1), rhs.ravel(), np.zeros(2 * (n + m)))
    if solution is None:
        raise ValueError(f"hz: {_NO_SOLUTION}")
    return solution.reshape(2, n + m)


_NO_SOLUTION = "the model cannot follow it: Âx_r + B̂u_r = ẋ_r has no solution with these outputs"


def _solve(M: Matrix, rhs: Vector, start: Vector) -> Vector | None:
    """Return the solution of M z = rhs nearest to a start, in scaled units; None if there is none."""
    size = np.abs(M).max(axis=1)
    rows = M / np.where(size > 0, size, 1.0)[:, None]
    targets = rhs / np.where(size > 0, size, 1.0)
    z = start
    for _ in range(2):  # the second corrects the rounding of the first
        z = z + np.linalg.lstsq(rows, targets - rows @ z, rcond=None)[0]
    residual = np.abs(rows @ z - targets)
    terms = np.abs(rows) @ (np.abs(z) + np.abs(start)) + np.abs(targets)
    is_solved = np.isfinite(z).all() and (residual <= _ROUNDING * max(float(terms.max()), 1e-300)).all()
    return np.where(np.abs(z) > _NEGLIGIBLE * np.abs([z, start]).max(), z, 0.0) if is_solved else None
