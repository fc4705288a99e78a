"""Certificates, margins and mean costs of a scenario."""

from collections.abc import Sequence
from contextlib import nullcontext

from cosim.analysis.certificates import Certificates, certificates_of
from cosim.analysis.margin_search import MOST_MANSD, MarginResult, find_margin
from cosim.analysis.mean_cost import MeanCost, find_mean_cost
from cosim.api.scenarios import Source, load
from cosim.live.monitoring.progress import work_bar
from noack.core.progress import no_progress
from noack.scenario.arrival_ties import with_later_updates
from noack.scenario.resolution import resolve
from noack.theory.witnesses.effort import MOST_WORK
from noack.theory.witnesses.loss_margin import ACCURACY


def certify(
    scenario: Source,
    *,
    late: int | None = None,
    search: bool = True,
    progress: bool = False,
) -> Certificates:
    """Return the certificates of a scenario: bounds that noack-check has proven, with their conditions.

    >>> import noack
    >>> certificate = noack.certify("double_integrator").schedule
    >>> certificate.exists
    True
    >>> certificate.formula("‖x‖", "x").startswith("‖x‖ ≤ 1.2")  # and decays
    True

    Args:
        scenario: a scenario, or a source that :func:`noack.load` accepts.
        late: plant steps by which the schedule may be late, 0 to 1000; by default the scenario's
            own value.
        search: search for the smallest bounds that can be proven, for some seconds, at most some minutes;
            what is found is kept in the cache folder of the user. Else those that need no search.
        progress: show a progress line on standard error.

    Raises:
        NoackError: the scenario is wrong, or its settings change during the run.
    """
    certificates = certificates_of(load(scenario), late)
    with work_bar("searching for proofs", lines=True) if progress else nullcontext(no_progress) as bar:
        certificates.prove(bar, MOST_WORK if search else 0.0)
    return certificates


def margin(
    scenario: Source,
    *,
    most_mansd: int = MOST_MANSD,
    accuracy: float = ACCURACY,
    period: bool = True,
    guarantees: Sequence[str] = (),
    effort: float = 1.0,
) -> MarginResult:
    """Return how many packets may be lost in a row while a loop is stable under every loss pattern.

    >>> import noack
    >>> noack.margin("lane_periodic", most_mansd=2, period=False).stable_mansd
    2

    Args:
        scenario: a scenario whose trigger has a longest time between two events, as ``periodic``
            and ``deadline`` have, or a source that :func:`noack.load` accepts.
        most_mansd: largest number of losses in a row to examine.
        accuracy: wanted ratio of upper and lower bound of the growth, minus 1.
        period: whether to search for the longest period with the scenario's own guarantee, too.
        guarantees: other guarantees to examine, in words such as ``mansd 4 atmost 3 in 10``.
        effort: factor of the work that a decision may take.

    Raises:
        NoackError: the scenario is wrong; or its trigger has no longest time, its loop is not
            linear, or its delay varies or is not below the shortest period.
    """
    return find_margin(
        resolve(load(scenario)),
        most_mansd=most_mansd,
        accuracy=accuracy,
        with_period=period,
        guarantees=guarantees,
        effort=effort,
    )


def cost(
    scenario: Source, *, Q: Sequence[object] | None = None, R: Sequence[object] | None = None
) -> MeanCost:
    """Return the mean cost ∫ xᵀQx + uᵀRu dt, and the rms of all states, under random losses.

    >>> import noack
    >>> mean_cost = noack.cost("lane_periodic")
    >>> round(mean_cost.with_guarantee.growth, 6)  # below 1: stable in mean square
    0.862511

    Args:
        scenario: a scenario with a time-triggered sensor (policy ``periodic``), or a source that
            :func:`noack.load` accepts.
        Q: weight of the state, (n, n), or its diagonal, (n,); None: the identity.
        R: weight of the input, (m, m) or (m,); None: the identity.

    Raises:
        NoackError: the scenario is wrong, or its loop is not covered; the message names the
            setting.
    """
    settled, _ = with_later_updates(load(scenario))
    return find_mean_cost(resolve(settled), Q, R)
