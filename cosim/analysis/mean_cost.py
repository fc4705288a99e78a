"""The mean cost of a time-triggered loop under random losses, with and without its guarantee."""

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, one_line, shortened
from netem.core.number_format import number
from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import loss_process
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.random_losses.exact_moments import LoopMoments, LoopPeriods, periods_of, start_of


class Stationary(NamedTuple):
    """What the loop tends to, whatever its start; root mean squares in the model's units.

    None: it depends on second moments that grow without a bound.
    """

    state_rms: tuple[float | None, ...]
    """Of each entry of x, over time."""
    state_rms_at_transmissions: tuple[float | None, ...]
    input_rms: tuple[float | None, ...]
    """Of each entry of u, without disturbances at the input."""
    cost_per_s: float | None
    """Mean of xᵀQx + uᵀRu over time."""


@dataclass(frozen=True)
class CostUnder:
    """What holds under a guarantee, or without one."""

    guarantee: str
    growth: float
    """Of √E‖z‖² per period; z is the state of plant, model and inputs."""
    stationary: Stationary
    horizon_cost: float | None
    """Mean of ∫ xᵀQx + uᵀRu dt from x(0) until the horizon, with disturbances and noise.

    None: not known, since there are too many periods until the horizon."""
    transient_cost: float | None
    """The same from x(0) for all time, without disturbances and noise.

    None: it depends on second moments that grow without a bound."""

    @property
    def grows(self) -> bool:
        """Whether the second moments grow without a bound."""
        return self.growth >= 1


@dataclass(frozen=True)
class MeanCost:
    """The mean cost of a loop; ``print`` shows it in words."""

    scenario: str
    mode: str
    period_s: float
    horizon_s: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    with_guarantee: CostUnder | str
    """Or why it is not known."""
    without_guarantee: CostUnder | str

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        document: dict[str, object] = dict(vars(self))
        for name in ("with_guarantee", "without_guarantee"):
            cost = getattr(self, name)
            if isinstance(cost, CostUnder):
                document[name] = vars(cost) | {"stationary": cost.stationary._asdict()}
        return document

    def __repr__(self) -> str:
        """Return what holds with the guarantee, in words."""
        cost = self.with_guarantee
        if isinstance(cost, str):
            return cost
        text = f"computed mean cost until {self.horizon_s:g} s: {number(cost.horizon_cost, 6)}"
        if cost.grows:
            text += f"; the second moments grow by {cost.growth:.6g} per period"
        if (per_s := cost.stationary.cost_per_s) is not None:
            text += f"; stationary: {per_s:.6g} /s"
        return text


def weight_matrix(name: str, given: object, size: int) -> Matrix:
    """Return a weight, (size, size), that is given by its rows or its diagonal; None: the identity.

    Raise CallerError if it has another shape, or entries that are no finite numbers.
    """
    try:
        value = np.eye(size) if given is None else np.array(given, dtype=np.float64)
    except (ValueError, TypeError):
        value = np.empty(0)
    if value.ndim == 1:
        value = np.diag(value)
    if value.shape != (size, size) or not np.isfinite(value).all():
        raise CallerError(
            f"{name} {shortened(one_line(str(given)))}: expected {size} x {size} numbers by rows, or {size} "
            f"for the diagonal, e.g. '{[1] * size}'"
        )
    return value


def require_weight(name: str, weight: Matrix, *, definite: bool = False) -> None:
    """Raise CallerError unless a weight of a cost is symmetric and positive (semi)definite, (k, k)."""
    if not np.allclose(weight, weight.T, rtol=1e-12, atol=0.0):
        raise CallerError(f"{name}: must be symmetric")
    smallest = np.linalg.eigvalsh(weight)[0]
    # Rounding may leave a singular weight with a small negative eigenvalue.
    if smallest < -1e-12 * np.abs(weight).max() or (definite and smallest <= 0):
        raise CallerError(f"{name}: must be positive {'definite' if definite else 'semidefinite'}")


@np.errstate(over="ignore", invalid="ignore")  # what overflows is not known
def find_mean_cost(resolved: Scenario, Q: object = None, R: object = None) -> MeanCost:
    """Return the mean of the cost ∫ xᵀQx + uᵀRu dt.

    Args:
        resolved: the resolved scenario, with a time-triggered sensor.
        Q: weight of the state, (n, n), positive semidefinite, or its diagonal, (n,); None: the identity.
        R: weight of the input, (m, m) or (m,), likewise.

    Raises:
        CallerError: a weight is wrong, or the loop is not covered; the message names the setting.
    """
    loop, link = loop_of(resolved), resolved.network.link
    n, size = loop.n, loop.n + loop.m
    forms = np.zeros((size + 1, size, size))
    entries = np.arange(size)
    forms[entries, entries, entries] = 1.0  # one form for each entry's square
    state_weight, input_weight = weight_matrix("Q", Q, n), weight_matrix("R", R, loop.m)
    require_weight("Q", state_weight)
    require_weight("R", input_weight)
    if not (state_weight.any() or input_weight.any()):
        raise CallerError("Q, R: all weights are 0")
    forms[size, :n, :n], forms[size, n:, n:] = state_weight, input_weight
    periods = periods_of(resolved, forms)

    def attempt(guarantee: LossGuarantee) -> CostUnder | str:
        try:
            return _cost_under(resolved, periods, guarantee)
        except NotPredictableError as error:
            return f"not known: {error}"

    return MeanCost(
        scenario=resolved.name,
        mode=resolved.mode,
        period_s=periods.times.seconds(periods.times.period),
        horizon_s=resolved.timing.horizon_ns / NS_PER_S,
        state_names=loop.state_names or tuple(f"x_{i + 1}" for i in range(n)),
        input_names=loop.input_names or tuple(f"u_{j + 1}" for j in range(loop.m)),
        with_guarantee=attempt(link.guarantee),
        without_guarantee=attempt(LossGuarantee()),
    )


def _cost_under(resolved: Scenario, periods: LoopPeriods, guarantee: LossGuarantee) -> CostUnder:
    """Return the moments under a guarantee; raise NotPredictableError if the losses are no chain."""
    outcomes = loss_process(resolved.network.link).outcomes(guarantee)
    if resolved.network.initial_sync == "known_state":  # nothing is sent at t = 0
        outcomes = outcomes.after_pause()
    moments, start = LoopMoments(periods, outcomes), start_of(resolved, outcomes, periods.size)
    n, m = resolved.model.dimensions[:2]
    whole_cost = n + m  # the number of the last form

    def over_time(form: int) -> float | None:
        fixed_point = moments.of_cost(form).stationary()
        return None if fixed_point is None else float(fixed_point[1][form])

    def at_transmissions(state: int) -> float | None:
        part = moments.of_cost(state)
        fixed_point, index = part.stationary(), part.states.index(state)
        return None if fixed_point is None else float(fixed_point[0].moments[:, index, index].sum())

    rms = _roots(map(over_time, range(n + m)))
    horizon_cost: float | None = None
    horizon = resolved.timing.horizon_ns * periods.times.parts
    with suppress(NotPredictableError):  # there are too many periods
        horizon_cost = float(moments.from_start(start, horizon)[1][whole_cost])
    transient = moments.of_cost(whole_cost).transient(start)
    return CostUnder(
        guarantee.meaning,
        moments.growth,
        Stationary(rms[:n], _roots(map(at_transmissions, range(n))), rms[n:], over_time(whole_cost)),
        horizon_cost,
        None if transient is None else float(transient[whole_cost]),
    )


def _roots(squares: Iterable[float | None]) -> tuple[float | None, ...]:
    """Return the roots of mean squares, of which rounding may leave a small negative one."""
    return tuple(None if square is None else math.sqrt(max(square, 0.0)) for square in squares)
