"""Computes the emulated network's decision for each update, without running a network."""

from collections.abc import Callable

from netem.channel import UPDATE_LINK
from netem.link_state import LinkState
from noack.config.scenario import Scenario
from noack.impairments.kinds.corrupt import Corrupt
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.protocol.record_tables import Fate


def timeless(settings: LinkSettings) -> LinkSettings:
    """Return the settings of a link that apply in the paper's loop: losses and corruption."""
    kept = tuple(one for one in settings.impairments if isinstance(one, LossOf | Corrupt))
    return settings.model_copy(update={"impairments": kept})


def network_fates(resolved: Scenario) -> Callable[[int], bool]:
    """Return whether the scenario's network delivers update i, for i = 0, 1, …, as in a live run.

    The emulator's losses and corruption depend only on its seed and on the order of arrival, so
    they can be computed without sending. Delays, rate limits and blackouts do not exist in the
    paper's loop and are ignored. For ``initial_sync = "first_packet"`` update 0 is delivered.
    """
    link = LinkState(timeless(resolved.network.link), resolved.seeds.loss, UPDATE_LINK)
    link.start_flow(0, 0)
    known: list[bool] = []

    def delivered(event: int) -> bool:
        while len(known) <= event:
            known.append(Fate(link.decide(0, 1, 0).fate).effective)
        return known[event]

    return delivered
