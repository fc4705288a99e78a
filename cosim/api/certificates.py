"""The certificates of a scenario, as an object."""

from typing import TYPE_CHECKING, Any

from cosim.api.scenarios import Source, load
from cosim.output.row_display import Rows, as_html, as_text
from noack.config.scenario import Scenario

if TYPE_CHECKING:
    from cosim.output.certificate_report import NetworkLimits, Study
    from noack.core.linear_systems import Matrix
    from noack.theory.paper_bounds import Theorem2
    from noack.theory.scenario_certificates import ScenarioCertificate


class Certificates:
    """The certificates of a scenario's plant, and of all plants in its uncertainty box.

    A certificate has ``constants``, or None with the reason in ``void``. It has ``conditions`` on
    network and schedule, which it assumes, and ``assumptions``, each with its verdict. It has
    ``inter_event_s``, the minimum inter-event time δ̲, and three bounds as functions of time in
    seconds: ``sensor_error``, ``controller_error`` and ``state``. The constants include ``delta``,
    Δ of ‖e_c‖ ≤ Δβe^(−αt), ``state``, X of ‖x‖ ≤ Xe^(−αt), and ``rate_per_s``, the decay rate of
    all bounds. ``docs/theory.md`` derives them.
    """

    def __init__(self, study: "Study") -> None:
        self._study = study

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario of the certificates, with the requested weight."""
        return self._study.resolved

    @property
    def paper(self) -> "ScenarioCertificate":
        """Under the paper's conditions: no sampling, no delay and no held input."""
        return self._study.certificate("paper")

    @property
    def schedule(self) -> "ScenarioCertificate":
        """Under the scenario's own schedule, with its permitted lateness."""
        return self._study.certificate("schedule")

    @property
    def paper_box(self) -> "ScenarioCertificate | None":
        """For every plant in the box, under the paper's conditions; None if there is no box."""
        return self._study.box_certificate("paper")

    @property
    def schedule_box(self) -> "ScenarioCertificate | None":
        """For every plant in the box, under the scenario's schedule; None if there is no box."""
        return self._study.box_certificate("schedule")

    @property
    def limits(self) -> "NetworkLimits":
        """Limits of the schedule's times for the scenario's plant, each varied alone, in s.

        They are computed at the first access, which takes about a second.
        """
        return next(iter(self._study.limits.values()))

    @property
    def theorem_2(self) -> "Theorem2 | None":
        """Theorem 2 by the paper's formula; None if it cannot be evaluated."""
        return self._study.theorem_2

    @property
    def weight(self) -> "Matrix | None":
        """W of the trigger's norm, (n, n), if this call chose it; else None."""
        return self._study.weight

    def to_json(self) -> dict[str, Any]:
        """Return all certificates as one document, as ``noack certify --json`` prints it."""
        return self._study.to_json()

    def _rows(self) -> Rows:
        from cosim.output.certificate_report import constants, whose

        found = self._study
        heads = [f"{under}, {whose(one)}" for under, one in found.certificates]
        rows = [[found.resolved.name, *heads]]
        rows += [[label, *values] for label, values, _ in constants(found)]
        return rows

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def certify(scenario: Source, *, weight: str = "given", late: int | None = None) -> Certificates:
    """Return the certificates of a scenario, with their constants and conditions.

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
    from cosim.output.certificate_report import study_scenario

    return Certificates(study_scenario(load(scenario), weight, late))
