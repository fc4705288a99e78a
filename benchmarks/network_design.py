"""``noack design --for network`` on shipped scenarios: the given and the designed loop."""

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from benchmarks.report import Peer, Row, benchmark
from cosim.shipped_files import find_shipped
from cosim.studies.design.event_design import EventSearch, design_for_network
from cosim.studies.design.network_search import Wish
from noack.scenario.scenario_file import load

_LINEAR = 'plant.system={kind="linear"}'


class Case(NamedTuple):
    """A scenario with settings; with a period it is time-triggered."""

    scenario: str
    period_s: float | None = None
    settings: tuple[str, ...] = ()


CASES = (
    Case("lane_following", 0.5),
    Case("unstable_pendulum", 0.25),
    Case("double_integrator", 2.0),
    Case("f16_lateral", 0.2, ("mode=zoh",)),
    Case("cart_pole", 0.2, (_LINEAR,)),
    Case("lane_following"),
    Case("unstable_pendulum"),
    Case("double_integrator"),
    Case("f16_lateral"),
    Case("cart_pole", None, (_LINEAR,)),
)


@benchmark("network_design", "Design for a network: the largest M of the given and a designed loop")
def network_design(options: argparse.Namespace) -> Iterator[Row]:
    """Design each scenario's loop; with events, for the bound of ‖x‖ that it has for its own M."""
    for name, period_s, settings in CASES:
        given = load(find_shipped(name, "scenarios"), settings)
        wish = Wish(period_s=period_s)
        kind = "events" if period_s is None else f"every {period_s:g} s"
        if period_s is None:
            search = EventSearch(given, wish, 0)
            bound = search.state_bound(search.given, given.network.mansd + 1)
            wish = Wish(bounds={"state": bound})
            kind = f"events, sup‖x‖ ≤ {bound:.4g} certified"
        found = design_for_network(given, wish)
        about = f"{' '.join((name, *settings[:1]))}, {kind}"
        keys = {"certified": "M", "cost": "cost", "transmissions": "transmissions"}
        for key in [key for key in keys if key in found.given]:
            before, after = (float(loop[key] or 0) for loop in (found.given, found.best))
            yield Row(f"{about}: {keys[key]}", after, "", Peer("given loop", before))
