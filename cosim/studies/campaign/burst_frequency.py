"""How often runs exceed M − 1 consecutive losses, if the network does not enforce the guarantee."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cosim.studies.campaign.draw_statistics import CONFIDENCE
from cosim.studies.campaign.metrics import Metric
from noack.config.scenario import Scenario
from noack.core.linear_systems import Vector
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_prediction import loss_process
from noack.impairments.markov_chain import NotPredictableError


class BurstFrequency(NamedTuple):
    """Runs with a burst of more than M − 1 losses, and their predicted share."""

    most: int
    """M − 1."""
    runs: int
    longer: int
    """Number of runs with a longer burst."""
    low: float
    """Low end of the confidence interval of their share (Clopper and Pearson)."""
    high: float
    packets: int
    """Largest number of packets of a run."""
    predicted: float
    """Probability of a longer burst in so many packets: an upper bound for the share."""

    @property
    def text(self) -> str:
        """The comparison, as part of a sentence."""
        return (
            f"{self.longer:,} of {self.runs:,} runs ({100 * self.longer / self.runs:.3g} %, "
            f"interval {100 * self.low:.3g} to {100 * self.high:.3g} %) had a burst longer than "
            f"M − 1 = {self.most}; at most {100 * self.predicted:.3g} % are expected, since no run "
            f"sent more than {self.packets:,} packets"
        )


def burst_frequency(scenario: Scenario, metrics: Mapping[Metric, Vector]) -> BurstFrequency | None:
    """Compare; None if the network enforces the guarantee or the losses cannot be predicted."""
    from scipy.stats import binomtest

    network = scenario.network
    if network.enforce_mansd or scenario.loops:
        return None
    bursts, packets = metrics["longest_loss_burst"], metrics["transmissions"]
    finished = np.isfinite(bursts)
    longer, runs = int((bursts[finished] > network.mansd).sum()), int(finished.sum())
    if not runs:
        return None
    interval = binomtest(longer, runs).proportion_ci(CONFIDENCE)
    most = int(packets[finished].max())
    try:
        kept = loss_process(network.link).keeps(LossGuarantee((LongestBurst(network.mansd),)), most)
    except NotPredictableError:
        return None
    return BurstFrequency(
        network.mansd, runs, longer, float(interval.low), float(interval.high), most, 1 - kept
    )
