"""The certificates of a scenario, and its margin of losses."""

from cosim.analysis.margin_search import MOST_M, MarginResult, find_margin
from cosim.api.scenarios import Source, load
from cosim.output.all_certificates import Certificates, certificates_of
from noack.config.resolution import resolve
from noack.theory.margins.joint_spectral_radius import ACCURACY


def certify(scenario: Source, *, weight: str = "given", late: int | None = None) -> Certificates:
    """Return the certificates of a scenario, with their constants and conditions.

    >>> import noack
    >>> found = noack.certify("lane_following")
    >>> found.schedule.constants is None  # there is one
    False
    >>> print(f"no two events closer than {1e3 * found.schedule.inter_event_s:.0f} ms")
    no two events closer than 8 ms

    Args:
        scenario: a scenario, or a source that :func:`noack.load` accepts.
        weight: W of the trigger's norm: ``given`` by the scenario, ``identity``, or ``chosen`` so
            that more can be certified, which takes some seconds.
        late: plant steps by which the schedule may be late, 0 to 1000; by default the scenario's
            own value.

    Raises:
        NoackError: the scenario is wrong, or there are no certificates for it: its trigger is not
            the paper's, its plant is not linear or is disturbed, or the state is not fully
            measured.
    """
    return certificates_of(load(scenario), weight, late)


def margin(
    scenario: Source, *, most_m: int = MOST_M, accuracy: float = ACCURACY, period: bool = True
) -> MarginResult:
    """Return the largest M for which a loop is stable under every loss pattern.

    >>> import noack
    >>> noack.margin("lane_periodic", most_m=3, period=False).stable_m
    3

    Args:
        scenario: a scenario whose trigger has a longest time between two events, as ``periodic``
            and ``deadline`` have, or a source that :func:`noack.load` accepts.
        most_m: largest M to examine.
        accuracy: wanted ratio of upper and lower bound of the growth, minus 1.
        period: whether to search for the longest period with the scenario's own M, too.

    Raises:
        NoackError: the scenario is wrong; or its trigger has no longest time, its loop is not
            linear, or its delay varies or is not below the shortest period.
    """
    return find_margin(
        resolve(load(scenario)), most_m=most_m, accuracy=accuracy, with_period=period
    )
