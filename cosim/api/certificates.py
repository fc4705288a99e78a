"""The certificates of a scenario."""

from cosim.api.scenarios import Source, load
from cosim.output.certificate_report import Certificates, certificates_of


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
    return certificates_of(load(scenario), weight, late)
