"""What loops need of a bottleneck: the refusal at its limit, and bounds that random loads test."""

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.simulation.virtual_time import simulate_loops
from noack.core.errors import CallerError
from noack.impairments.feature import Impairment
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import require_scores
from noack.protocol.record_tables import NETEM_PACKET
from noack.protocol.wire_format import datagram_bytes
from noack.scenario.link_load import link_loads, load_warnings, require_capacity, update_delay
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.netem.feature_examples import IMPAIRED, keeps_loss, names_file
from tests.oracles.link import Datagram, Link

PERIODIC = {"policy": "periodic", "period_s": 0.05}
BITS = 8 * (datagram_bytes(2) + 28)


def scenario_of(
    content: dict[str, Any], rate_bps: int, queue: int, *loops: dict[str, Any], **network: Any
) -> Scenario:
    rate = {"kind": "rate", "rate_bps": rate_bps, "queue": queue}
    content["network"] |= {"impairments": [rate], **network}
    return validate(content | {"loops": list(loops)}, "here")


DEADLINE = {"policy": "deadline", "interval_s": 0.049,
            "rule": {"policy": "decaying", "beta": 0.5, "alpha_per_s": 0.25}}  # fmt: skip


@pytest.mark.parametrize(
    ("trigger", "constraints", "share"),
    [
        (PERIODIC, [], 1 / 3),
        (DEADLINE, [], 1 / 3),
        (PERIODIC, [{"kind": "at_most", "losses": 1, "window": 10}], 9 / 10),
        (PERIODIC, [{"kind": "recovery", "deliveries": 3}], 3 / 5),
    ],
)
def test_the_rate_for_what_must_pass_is_the_limit(
    content: dict[str, Any], trigger: dict[str, Any], constraints: list[Any], share: float
) -> None:
    """At 100 Hz, a deadline of 49 ms means an event every 50 ms at the latest."""
    content["plant"]["rate_hz"] = 100.0
    loops = {"name": "a", "count": 30, "trigger": trigger}
    needed_bps = round(30 * BITS / 0.05 * share)
    require_capacity(scenario_of(content, needed_bps, 5, loops, constraints=constraints))
    with pytest.raises(CallerError, match=re.escape(f"need {needed_bps} bit/s")):
        require_capacity(scenario_of(content, needed_bps - 1, 5, loops, constraints=constraints))
    # Without the guarantee nothing must pass.
    require_capacity(scenario_of(content, 1000, 5, loops, enforce_mansd=False))


def test_a_change_can_require_more(content: dict[str, Any]) -> None:
    """From M − 1 = 2 to 0: each of the 20 datagrams a second of each of 30 loops must pass."""
    content["changes"] = [{"at_s": 0.5, "set": {"network.mansd": 0}}]
    content["horizon_s"] = 1.0
    loops = {"name": "a", "count": 30, "trigger": PERIODIC}
    needed_bps = 30 * BITS * 20
    require_capacity(scenario_of(content, needed_bps, 5, loops))
    with pytest.raises(CallerError, match=rf"changes\.0 .* 1 of any 1 .* need {needed_bps} bit/s"):
        require_capacity(scenario_of(content, needed_bps - 1, 5, loops))


def test_recorded_opportunities_are_a_bottleneck(content: dict[str, Any]) -> None:
    """An opportunity carries 1504 bytes; a datagram has 32 more than its payload."""
    bits = 8 * (datagram_bytes(2) + 32)
    loops = {"name": "a", "count": 30, "trigger": PERIODIC}
    needed_bps = 30 * bits / 0.05 / 3

    def checked(period_ms: int) -> None:
        stage = {"kind": "opportunities", "times_ms": [period_ms]}
        content["network"]["impairments"] = [stage]
        require_capacity(validate(content | {"loops": [loops]}, "here"))

    most_ms = int(1000 * 8 * 1504 / needed_bps)
    checked(most_ms)
    with pytest.raises(CallerError, match=f"need {int(needed_bps)} bit/s"):
        checked(most_ms + 1)


def test_the_actuations_need_a_rate_too(content: dict[str, Any]) -> None:
    """30 controllers with 500 ticks a second; one of any 5 actuations must pass."""
    inputs = len(content["model"].get("B", [[0]])[0])
    bits = 8 * (datagram_bytes(inputs) + 28)
    needed_bps = 30 * bits * 500 // 5

    def checked(rate_bps: int, **actuation: Any) -> None:
        rate = {"kind": "rate", "rate_bps": rate_bps, "queue": 5}
        network = content["network"] | {"actuation": {"impairments": [rate], **actuation}}
        loops = [{"name": "a", "count": 30}]
        require_capacity(validate(content | {"network": network, "loops": loops}, "here"))

    checked(needed_bps, mansd=4)
    with pytest.raises(CallerError, match=rf"network\.actuation.*any 5 .* need {needed_bps} bit/s"):
        checked(needed_bps - 1, mansd=4)
    checked(1000)  # without a guarantee nothing must pass


def test_an_event_trigger_is_only_warned_about(content: dict[str, Any]) -> None:
    loops = {"name": "a", "count": 30}
    slow = scenario_of(content, 1000, 5, loops)
    require_capacity(slow)
    (warning,) = load_warnings(link_loads(slow), slow)
    assert f"need {30 * BITS * 500 // 3} bit/s" in warning
    fast = scenario_of(content, 30 * BITS * 500, 5, loops)
    assert [*load_warnings(link_loads(fast), fast)] == []


def test_the_bound_of_the_delay_covers_changes(content: dict[str, Any]) -> None:
    """The link carries all datagrams of 20 loops at first, and half of them after the change."""
    content["plant"] |= {"rate_hz": 100.0, "initial_state_halfwidth": [0.5, 0.5]}
    content["controller"] = {"rate_hz": 100.0}
    content["changes"] = [{"at_s": 1.0, "set": {"trigger.period_s": 0.05}}]
    content["horizon_s"] = 3.0
    content["trigger"] = {"policy": "periodic", "period_s": 0.1}
    loops = {"name": "a", "count": 20, "phase": 0.0}
    scenario = scenario_of(content, 20 * BITS * 10, 100, loops, mansd=5)
    packets = simulate_loops(scenario).network[NETEM_PACKET]
    longest_s = 1e-9 * (packets["release_ns"] - packets["now_ns"]).max()
    loads = link_loads(scenario)
    assert [load.begin for load in loads] == ["", "from changes.0 on, "]
    assert all(longest_s <= (load.delay_bound_s or 0.0) for load in loads)
    assert longest_s > 0.12  # the bound for the settings at the start is 0.1


def longest_delay_s(scenario: Scenario, loops: int, seed: int, together: bool) -> float:
    """Return the longest delay of 200 updates of each loop, 50 ms apart or more."""
    rng = np.random.default_rng(seed)
    gaps_s = 0.05 * (1 + (rng.random((loops, 200)) < 0.2) * rng.random((loops, 200)))
    begin_s = 0.0 if together else rng.uniform(0, 0.05, (loops, 1))
    times_ns = ((begin_s + np.cumsum(gaps_s, axis=1)) * 1e9).round().astype(np.int64)
    link = Link(scenario.network.link, seed, "x")
    size = datagram_bytes(2)
    longest_ns = 0
    for place in np.argsort(times_ns, axis=None, kind="stable").tolist():
        now_ns = int(times_ns.ravel()[place])
        while (due_ns := link.next_deadline_ns()) is not None and due_ns <= now_ns:
            link.on_timer(due_ns)
        link.handle(Datagram(place // 200, bytes(size)), now_ns)
        leaves_ns = max(link.decision.release_ns, link.decision.copy_ns)
        longest_ns = max(longest_ns, leaves_ns - now_ns)
    return longest_ns * 1e-9


def test_the_delay_after_a_queue_counts(content: dict[str, Any]) -> None:
    """Ten updates of 736 bits at 80 kbit/s wait for up to 92 ms, and are delayed by 50 ms more."""
    content["plant"]["rate_hz"] = 100.0
    loops = {"name": "a", "count": 10, "trigger": PERIODIC | {"period_s": 0.1}}

    def warnings(stages: list[Any], covered_s: float) -> list[str]:
        given = [one.model_dump(mode="json", exclude_none=True) for one in stages]
        content["network"]["impairments"] = given
        content["certificate"] = {"network_delay_s": covered_s}
        scenario = validate(content | {"loops": [loops]}, "here")
        return [*load_warnings(link_loads(scenario), scenario)]

    queue = Rate(rate_bps=80_000, queue=20)
    for order in ([queue, Delay(delay_s=0.05)], [Delay(delay_s=0.05), queue]):
        (warning,) = warnings(order, 0.1)
        assert "updates may be delayed by up to 0.142 s" in warning
        assert "the certificates cover 0.1 s" in warning
        assert warnings(order, 0.142) == []
    (warning,) = warnings([queue, Delay(jitter_s=0.001, distribution="normal")], 10.0)
    assert "no bound of the delay of updates is known (network.impairments.1)" in warning


def _is_alone_valid(one: Impairment) -> bool:
    """Whether it needs no file, and no loss rate of several stages together."""
    return not names_file(one) and not keeps_loss(one)


EXAMPLES = [one for one in IMPAIRED if _is_alone_valid(one)]
QUEUES = [
    Rate(rate_bps=round(7 * BITS / 0.05 * share), queue=queue)
    for share in (0.4, 0.7, 1.1, 2.5) for queue in (1, 4)
]  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(
    stages=st.lists(st.sampled_from(EXAMPLES) | st.sampled_from(QUEUES), max_size=5),
    loops=st.integers(1, 7),
    seed=st.integers(0, 2**32),
    together=st.booleans(),
    covered=st.sampled_from([0.5, 0.99, 1.0, 1.01, 3.0]),
)
def test_the_largest_delay_is_bounded_and_a_warning_tells_that_it_is_not_covered(
    stages: list[Impairment], loops: int, seed: int, together: bool, covered: float
) -> None:
    """Every kind of impairment, in any order; updates are held back for the guarantee, M = 3."""
    try:
        require_scores(stages)
    except ValueError:
        stages = [one for one in stages if not getattr(one, "loss_correlation", 0)]
    content = {
        "name": "small", "horizon_s": 1.0, "model": {"name": "double_integrator"},
        "plant": {"initial_state": [1.0, 0.0]}, "trigger": PERIODIC,
        "network": {"mansd": 2, "loss": {"model": "bernoulli", "probability": 0.3}},
    }  # fmt: skip
    scenario = scenario_of(content, 1000, 1, {"name": "a", "count": loops})
    network = scenario.network.model_copy(update={"impairments": tuple(stages)})
    scenario = scenario.model_copy(update={"network": network})
    bound_s = update_delay(scenario).largest_s
    longest_s = longest_delay_s(scenario, loops, seed, together)
    assert longest_s <= bound_s + 1e-9 * (len(stages) + 1)
    covered_s = covered * (bound_s if math.isfinite(bound_s) else longest_s)
    certificate = scenario.certificate.model_copy(update={"network_delay_s": covered_s})
    scenario = scenario.model_copy(update={"certificate": certificate})
    warnings = [*load_warnings(link_loads(scenario), scenario)]
    warned = any("certificates cover" in one or "without bound" in one for one in warnings)
    assert warned == (bound_s > covered_s)
