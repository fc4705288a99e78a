"""The metrics of the runs of a campaign, and the certified bound of ‖e_c‖."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.exact_simulation import OK
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Vector
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import Output, error_gains

Metric = Literal[
    "transmissions",
    "deliveries",
    "lost_share",
    "longest_loss_burst",
    "inter_event_min_s",
    "inter_event_mean_s",
    "settling_s",
    "cost",
    "cost_worst",
    "loops_failed",
    "loops_claims_held",
    "loops_guarantee_used",
    "updates_late",
    "delay_max_s",
    "sup_e_c_scaled",
    "certificate_used",
    "final_norm",
]


class Description(NamedTuple):
    """Names of a metric."""

    title: str
    unit: str = ""
    meaning: str = ""
    """Formula, if the title needs one."""
    logarithmic: bool = False
    """Whether the axis of a figure may be logarithmic."""

    @property
    def heading(self) -> str:
        """Heading of a column."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def label(self) -> str:
        """Label of an axis."""
        return f"{self.title} {self.meaning}".strip() + (f" [{self.unit}]" if self.unit else "")


METRICS: Mapping[Metric, Description] = {
    "transmissions": Description("transmissions", logarithmic=True),
    "deliveries": Description("deliveries", logarithmic=True),
    "lost_share": Description("share lost"),
    "longest_loss_burst": Description("longest loss burst"),
    "inter_event_min_s": Description("shortest interval", "s", logarithmic=True),
    "inter_event_mean_s": Description("mean interval", "s", logarithmic=True),
    "settling_s": Description("settling time", "s"),
    "cost": Description("cost", "", "∫ xᵀQx + uᵀRu dt", logarithmic=True),
    "cost_worst": Description("cost of the worst loop", logarithmic=True),
    "loops_failed": Description("share of loops that failed"),
    "loops_claims_held": Description("share of loops that hold all claims"),
    "loops_guarantee_used": Description("share of loops that used up the guarantee"),
    "updates_late": Description("share of updates that are late"),
    "delay_max_s": Description("largest delay in the network", "s", logarithmic=True),
    "sup_e_c_scaled": Description("largest error", "", "sup ‖e_c‖ e^(αt)"),
    "certificate_used": Description("bound used", "", "sup ‖e_c‖ e^(αt) / Δβ"),
    "final_norm": Description("final state", "", "‖x‖", logarithmic=True),
}


def measured(columns: Mapping[str, NDArray[Any]], certified: float | None) -> dict[Metric, Vector]:
    """Return all metrics of k runs.

    A time is infinite if its event does not happen. All metrics of a failed run are infinite.
    Without a certified Δβ, the result has no ``certificate_used``.
    """
    found: dict[Metric, Vector] = {}
    failed = columns["status"] != OK
    for name in METRICS:
        if name in columns:
            values = np.asarray(columns[name], dtype=np.float64)
            if name == "loops_claims_held" and np.isnan(values).all():  # they were not judged
                continue
            found[name] = np.where(np.isnan(values) | failed, np.inf, values)
    arrived = columns["deliveries"] / np.maximum(columns["transmissions"], 1)
    found["lost_share"] = np.where(failed, np.inf, 1.0 - arrived)
    if certified is not None:
        found["certificate_used"] = found["sup_e_c_scaled"] / certified
    return found


def certified_error(resolved: Scenario) -> float | None:
    """Return Δβ with ‖e_c‖_W ≤ Δβe^{−αt} for every plant and every x(0); None if there is none.

    By identity (I1), Δ is the sum of the gains of the present error and of the longest burst of
    lost ones, for any inter-event times. It depends on the models only. It exists if the models
    decay faster than the threshold (a zero-order hold does not), the threshold has no floor, and
    the network enforces the guarantee.
    """
    network = resolved.network
    if not resolved.coverage.is_decaying or not network.enforce_mansd:
        return None
    trigger = resolved.decaying
    if trigger.floor > 0:
        return None
    models = error_gains(loop_of(resolved), trigger.alpha_per_s)
    try:
        missing = models.missing(Output.WEIGHTED, network.longest_burst, 0.0)
    except NotDecayingError:
        return None
    return (models.now(Output.WEIGHTED) + missing) * trigger.beta
