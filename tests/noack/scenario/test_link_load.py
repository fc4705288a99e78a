"""What loops need of a bottleneck, and the largest delay of their updates."""

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from noack.core.errors import CallerError
from noack.impairments.feature import Impairment
from noack.impairments.kinds.rate import Rate
from noack.impairments.kinds.schedule import Schedule
from noack.impairments.link_settings import require_scores
from noack.protocol.wire_format import datagram_bytes
from noack.scenario.link_load import link_loads, load_warnings, require_capacity, update_delay
from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.conditions import certified_delay_s
from tests.noack.impairments.feature_examples import IMPAIRED, keeps_loss, names_file
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


@pytest.mark.parametrize(
    ("trigger", "least_s", "largest_s"),
    [
        (PERIODIC, 0.05, 0.05),
        ({"policy": "dwell", "interval_s": 0.02, "rule": PERIODIC}, 0.05, 0.05),
        ({"policy": "dwell", "interval_s": 0.3, "rule": DEADLINE["rule"]}, 0.3, math.inf),
        # What is due happens in spite of a dwell time.
        ({**DEADLINE, "rule": {"policy": "dwell", "interval_s": 0.3, "rule": DEADLINE["rule"]}}, 0.049, 0.05),
    ],
)
def test_the_load_is_that_of_the_shortest_and_the_longest_time_between_events(
    content: dict[str, Any], trigger: dict[str, Any], least_s: float, largest_s: float
) -> None:
    content["plant"]["rate_hz"] = 100.0
    (load,) = link_loads(scenario_of(content, 10**6, 5, {"name": "a", "trigger": trigger}))
    assert load.mandatory_at_most_bps == pytest.approx(BITS / 3 / least_s)
    assert load.mandatory_at_least_bps == pytest.approx(BITS / 3 / largest_s)


def test_an_event_trigger_is_only_warned_about(content: dict[str, Any]) -> None:
    loops = {"name": "a", "count": 30}
    slow = scenario_of(content, 1000, 5, loops)
    require_capacity(slow)
    (warning,) = load_warnings(link_loads(slow), slow)
    assert f"need {30 * BITS * 500 // 3} bit/s" in warning
    fast = scenario_of(content, 30 * BITS * 500, 5, loops)
    assert [*load_warnings(link_loads(fast), fast)] == []
    delay = {"kind": "delay", "jitter_s": 0.001, "distribution": "normal"}
    slow = scenario_of(content, 1000, 5, loops, impairments=[delay])
    (warning,) = load_warnings(link_loads(slow), slow)
    assert "no bound of the delay of updates is known (network.impairments.0)" in warning


def test_recorded_opportunities_are_a_bottleneck(content: dict[str, Any]) -> None:
    """An opportunity carries 1504 bytes; a datagram has 32 more than its payload."""
    loops = {"name": "a", "count": 30, "trigger": PERIODIC}
    needed_bps = 30 * 8 * (datagram_bytes(2) + 32) / 0.05 / 3
    most_ms = int(1000 * 8 * 1504 / needed_bps)
    enough, less = (
        scenario_of(content, 1, 1, loops, impairments=[{"kind": "opportunities", "times_ms": [ms]}])
        for ms in (most_ms, most_ms + 1)
    )
    require_capacity(enough)
    with pytest.raises(CallerError, match=f"need {int(needed_bps)} bit/s"):
        require_capacity(less)


@pytest.mark.parametrize(
    ("order", "says"),
    [
        ([0, 1, 0], "order: loop 2 has no slot; the run has the loops 0 to 2"),
        ([1, 2, 3, 0], "order: a slot is for loop 3; the run has the loops 0 to 2"),
        ([0, 0, 0, 1, 2], "loop 1 (a-2), the datagrams that must pass, 1 of any 3 of each loop, need"),
    ],
)
def test_a_schedule_has_enough_slots_for_each_loop(
    content: dict[str, Any], order: list[int], says: str
) -> None:
    """Loop 1 needs a slot in 3 × 50 ms; of five of these, it has one."""
    loops = {"name": "a", "count": 3, "trigger": PERIODIC}

    def given(slot_s: float) -> Scenario:
        schedule = {"kind": "schedule", "order": order, "slot_s": slot_s}
        return scenario_of(content, 1, 1, loops, impairments=[schedule])

    with pytest.raises(CallerError, match=re.escape(says)):
        require_capacity(given(0.031))
    if len(order) == 5:
        require_capacity(given(0.03))


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


RATE_BPS = BITS / 0.05
"""Of one loop that transmits every 50 ms."""
CORRUPT = {"kind": "corrupt", "probability": 1.0}
DELAYS_NS = [150_000_000, 100_000_000, 50_000_000, 0]
REPLAY = {"kind": "replay", "sent_ns": [0, 1, 2, 3], "delays_ns": DELAYS_NS}
TIGHT: list[tuple[list[dict[str, Any]], int, float, float]] = [
    # Four datagrams reach the queue at once. Then: what finds it full must pass.
    ([REPLAY, {"kind": "rate", "rate_bps": RATE_BPS}], 1, 0.15 + 0.2, 0.2),
    ([{"kind": "rate", "rate_bps": 0.7 * RATE_BPS, "queue": 2}, CORRUPT], 19,
     3 * 0.05 / 0.65, 0.157),
    # The same in slots, which are taken by datagrams that are lost later; two copies.
    ([{"kind": "schedule", "order": [0, -1], "slot_s": 0.05, "queue": 1}, CORRUPT], 1, 0.2, 0.12),
    ([{"kind": "duplicate", "probability": 1.0}, {"kind": "schedule", "order": [0],
      "slot_s": 0.025}], 1, 0.05, 0.04),
]  # fmt: skip


@pytest.mark.parametrize(("stages", "mansd", "bound_s", "reached_s"), TIGHT)
def test_the_bound_of_the_delay_is_in_closed_form_and_nearly_reached(
    content: dict[str, Any], stages: list[dict[str, Any]], mansd: int, bound_s: float,
    reached_s: float,
) -> None:  # fmt: skip
    loops = {"name": "a", "count": 1, "trigger": PERIODIC}
    stages = [stage | {"rate_bps": round(stage["rate_bps"])} if "rate_bps" in stage else stage
              for stage in stages]  # fmt: skip
    given = scenario_of(content, 1000, 1, loops, impairments=stages, mansd=mansd)
    assert update_delay(given).largest_s == pytest.approx(bound_s, rel=1e-3)
    longest_s = max(longest_delay_s(given, 1, seed, together=False) for seed in range(8))
    assert reached_s <= longest_s <= bound_s * 1.001


def _is_alone_valid(impairment: Impairment) -> bool:
    """Whether it needs no file, and no loss rate of several stages together."""
    return not names_file(impairment) and not keeps_loss(impairment)


EXAMPLES = [impairment for impairment in IMPAIRED if _is_alone_valid(impairment)]
QUEUES = [
    Rate(rate_bps=round(7 * BITS / 0.05 * share), queue=queue)
    for share in (0.4, 0.7, 1.1, 2.5) for queue in (1, 4)
]  # fmt: skip
SCHEDULES = [
    Schedule(order=order, slot_s=round_s / len(order), queue=queue)
    for order in (tuple(range(7)), (*(0, 1, 0) * 2, *range(7)), (6, *range(6), *(0, 6)))
    for round_s in (0.04, 0.05, 0.11, 0.2) for queue in (1, 4)
]  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(
    stages=st.lists(st.sampled_from([*SCHEDULES, *QUEUES]) | st.sampled_from(EXAMPLES), max_size=5),
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
        stages = [stage for stage in stages if not getattr(stage, "loss_correlation", 0)]
    content = {
        "name": "small", "horizon_s": 1.0, "model": {"name": "double_integrator"},
        "plant": {"initial_state": [1.0, 0.0]}, "trigger": PERIODIC,
        "network": {"mansd": 2, "loss": {"model": "bernoulli", "probability": 0.3}},
    }  # fmt: skip
    scenario = scenario_of(content, 1000, 1, {"name": "a", "count": loops})
    network = scenario.network.model_copy(update={"impairments": tuple(stages)})
    scenario = scenario.model_copy(update={"network": network})
    bound = update_delay(scenario)
    bound_s = bound.largest_s
    longest_s = longest_delay_s(scenario, loops, seed, together)
    assert longest_s <= bound_s + 1e-9 * (len(stages) + 1)
    longest = scenario.network.link.longest_delay_s
    for loop, own_s in zip(resolved_loops(scenario), bound.loops_s, strict=True):
        assert certified_delay_s(loop) == pytest.approx(own_s if math.isfinite(own_s) else longest)
    covered_s = covered * (bound_s if math.isfinite(bound_s) else longest_s)
    certificate = scenario.certificate.model_copy(update={"network_delay_s": covered_s})
    scenario = scenario.model_copy(update={"certificate": certificate})
    warnings = [*load_warnings(link_loads(scenario), scenario)]
    warned = any("certificates cover" in warning or "without bound" in warning for warning in warnings)
    assert warned == (bound_s > covered_s)
