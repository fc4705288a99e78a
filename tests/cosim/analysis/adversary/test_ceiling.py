"""The upper bound on the cost of the rest of a run, against the actual cost."""

import numpy as np
from hypothesis import given, settings

from cosim.analysis.adversary.cost_bound import cost_ceiling
from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.pattern_tree import search_tree
from cosim.analysis.adversary.search_nodes import Nodes
from noack.config.scenario import Scenario
from tests.cosim.analysis.adversary.scenarios import every_run, flow_of, scenarios


@given(resolved=scenarios(8))
@settings(max_examples=5)
def test_no_run_ever_costs_more_than_the_ceiling(resolved: Scenario) -> None:
    system, _, flow = flow_of(resolved, Objective.COST)
    ceiling = cost_ceiling(system, resolved.network.mansd, resolved.horizon_s)
    assert ceiling is not None
    for run in every_run(resolved):
        states = (run.start, *run.after) if flow.known_start else run.after
        t_s = np.array([state.t_s for state in states])
        z = np.array([np.concatenate(state[1:]) for state in states])
        still = np.cumsum(flow(t_s, z).value[::-1])[::-1]
        nothing = np.zeros(len(t_s))
        nodes = Nodes(t_s, z, nothing.astype(int), nothing, nothing.astype(int))
        assert (still <= ceiling(nodes) * (1 + 1e-9)).all()


@given(resolved=scenarios(12, mansd=2, beta=0.01))
@settings(max_examples=5)
def test_what_the_ceiling_leaves_out_is_not_missed(resolved: Scenario) -> None:
    system, _, flow = flow_of(resolved, Objective.COST)
    ceiling = cost_ceiling(system, 2, resolved.horizon_s)
    all_nodes = search_tree(flow, 2, 10**5)
    fewer = search_tree(flow, 2, 10**5, ceiling=ceiling)
    assert fewer.value == all_nodes.value
    assert fewer.nodes <= all_nodes.nodes


def test_the_ceiling_leaves_something_out() -> None:
    """Without an excluded pattern, the test above would check nothing."""
    saved = []

    @given(resolved=scenarios(12, mansd=2, beta=0.01, mismatch=0.1))
    @settings(max_examples=5)
    def count(resolved: Scenario) -> None:
        system, _, flow = flow_of(resolved, Objective.COST)
        best = search_tree(flow, 2, 10**5)
        ceiling = cost_ceiling(system, 2, resolved.horizon_s)
        fewer = search_tree(flow, 2, 10**5, known=best.value * (1 - 1e-9), ceiling=ceiling)
        assert fewer.value == best.value
        saved.append(fewer.nodes < best.nodes)

    count()
    assert any(saved)
