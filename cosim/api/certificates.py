"""What is guaranteed of a scenario, as a value."""

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
    """What is guaranteed of a scenario: of its plant, and of every plant of its uncertainty box.

    Each certificate has ``constants``, or None and in ``void`` the reason; ``conditions``, which it
    presupposes of network and schedule; ``assumptions``, each with its verdict; ``inter_event_s``,
    δ̲; and the bounds as functions of time in seconds, ``sensor_error``, ``controller_error`` and
    ``state``. Among the constants are ``delta``, Δ of ‖e_c‖ ≤ Δβe^(−αt), ``state``, X of
    ‖x‖ ≤ Xe^(−αt), and ``rate_per_s``, at which all bounds fall. ``docs/theory.md`` derives them.
    """

    def __init__(self, study: "Study") -> None:
        self._study = study

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario that they are of, with the weight that was asked for."""
        return self._study.resolved

    @property
    def paper(self) -> "ScenarioCertificate":
        """Under the paper's conditions: nothing is sampled, delayed or held."""
        return self._study.certificate("paper")

    @property
    def schedule(self) -> "ScenarioCertificate":
        """Under the scenario's own schedule, late by what it allows."""
        return self._study.certificate("schedule")

    @property
    def paper_box(self) -> "ScenarioCertificate | None":
        """Of every plant of the box, under the paper's conditions; None if there is no box."""
        return self._study.box_certificate("paper")

    @property
    def schedule_box(self) -> "ScenarioCertificate | None":
        """Of every plant of the box, under the scenario's schedule; None if there is no box."""
        return self._study.box_certificate("schedule")

    @property
    def limits(self) -> "NetworkLimits":
        """How far the schedule could go, one thing at a time; of the scenario's plant, in s.

        Found when it is first asked for, in a second or so.
        """
        return next(iter(self._study.limits.values()))

    @property
    def theorem_2(self) -> "Theorem2 | None":
        """The paper's Theorem 2 as it is printed; None where it cannot be evaluated."""
        return self._study.theorem_2

    @property
    def weight(self) -> "Matrix | None":
        """W of the trigger's norm, (n, n), if it was chosen here; None otherwise."""
        return self._study.weight

    def to_json(self) -> dict[str, Any]:
        """Everything as one document, as ``noack certify --json`` prints it."""
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
    """Say what is guaranteed of a scenario, with which constants, under which conditions.

    Args:
        scenario: as :func:`noack.load` gives it, or takes it.
        weight: of the trigger's norm: ``given`` by the scenario, ``identity``, or ``chosen`` here,
            which takes some seconds, so that more can be certified.
        late: steps of the plant by which the schedule may be late, 0 to 1000; the scenario's own
            allowance unless given.

    Raises:
        NoackError: the scenario is wrong, or none of which there are certificates: its trigger is
            not the paper's, its plant is not linear, or disturbed, or measured in part.
    """
    from cosim.output.certificate_report import study_scenario

    return Certificates(study_scenario(load(scenario), weight, late))
