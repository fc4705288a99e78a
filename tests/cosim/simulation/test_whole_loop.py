"""Runs in virtual time against the reference loop of tests/oracles/whole_loop.py and the paper."""

from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_statistics import unintended_losses
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.roles import RECEIVES, SENDS, receiver_of
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load, validate
from noack.scenario.sections import POLICIES as POLICY_KINDS
from tests.helpers.wire_decoder import Decoder
from tests.oracles.comparison import Comparison
from tests.oracles.random_scenarios import POLICIES, random_scenario
from tests.oracles.reference_run import settings_of, why_not
from tests.oracles.trigger_rules import Array
from tests.oracles.whole_loop import NONE

SCENARIOS = sorted((Path(__file__).parents[3] / "scenarios").glob("*.toml"))
RANDOM = 96
"""Random scenarios: 8 of each trigger policy."""
COVERING = (
    1, 2, 4, 6, 7, 9, 10, 12, 20, 29, 38, 45, 48, 53, 55, 59, 61, 68, 71, 75, 87, 88, 90, 94,
)  # fmt: skip
"""Two of each trigger policy, which together have every feature at least twice."""
DRAWS = pytest.mark.parametrize(
    "draws",
    [pytest.param(COVERING, id="some"), pytest.param(range(RANDOM), id="all", marks=pytest.mark.deep)],
)
SHORTER = ["horizon_s=2.0"]
AT_A_LOWER_RATE = ["plant.rate_hz=100", "controller.rate_hz=100"]
"""Of the scenario that has an outage later."""


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_a_shipped_scenario_runs_as_the_reference_loop(path: Path) -> None:
    scenario = load(path, AT_A_LOWER_RATE if path.stem == "lane_5g_rural" else SHORTER)
    if reason := why_not(scenario):
        pytest.skip(reason)
    assert Comparison(simulate(resolve(scenario))).tie_ns is None


def test_every_policy_is_among_the_random_scenarios() -> None:
    assert {*POLICIES} == POLICY_KINDS.keys() - {"python"}


@cache
def random_run(number: int) -> RunRecord:
    return simulate(resolve(validate(random_scenario(number), "random")))


@cache
def compared(number: int) -> Comparison:
    return Comparison(random_run(number))


def of_policy(policy: str, draws: Sequence[int]) -> list[int]:
    return [number for number in draws if number % len(POLICIES) == POLICIES.index(policy)]


@DRAWS
@pytest.mark.parametrize("policy", POLICIES)
def test_random_scenarios_run_as_the_reference_loop(policy: str, draws: Sequence[int]) -> None:
    outcomes = [compared(number) for number in of_policy(policy, draws)]
    assert sum(outcome.tie_ns is not None for outcome in outcomes) <= 1
    events = sum((outcome.rows["sensor_measurement"]["event"] != NONE).sum() for outcome in outcomes)
    assert events > 4 * len(outcomes)


@DRAWS
@pytest.mark.parametrize("policy", POLICIES)
def test_random_runs_are_replayed_and_keep_the_guarantee_of_each_direction(
    policy: str, draws: Sequence[int]
) -> None:
    for number in of_policy(policy, draws):
        record = random_run(number)
        result = replay(record)
        assert (result.bit_exact, result.gaps) == (True, []), result.first_difference
        assert result.inputs == sum(map(record.count, record.tables))
        assert sum(unintended_losses(record).values()) == 0
        network = record.scenario.network
        links = (network, network.actuation or network.acknowledgements)
        for flow, link in zip(network.flows, links, strict=False):
            if not record.scenario.changes:
                assert packet_outcomes(record, flow).longest_loss_burst() <= link.mansd


def rejected_in(record: RunRecord) -> set[str]:
    """The reasons for which datagrams were rejected."""
    return {reason for report in record.reports.values() for reason in report["channel"]["rejected"]}


@DRAWS
def test_the_random_scenarios_have_every_feature(draws: Sequence[int]) -> None:
    counts: Counter[str] = Counter()
    for number in draws:
        scenario, outcome = random_run(number).scenario, compared(number)
        steps, measured = outcome.reference["plant_step"], outcome.reference["sensor_measurement"]
        delivered, packets = outcome.reference["controller_delivery"], outcome.rows["netem_packet"]
        has = {
            scenario.mode: True,
            scenario.network.initial_sync: True,
            f"observer {scenario.observer and scenario.observer.kind}": True,
            f"watchdog {scenario.plant.watchdog.policy}": any(r["entry"] == NONE for r in steps),
            "prediction": any(row["entry"] > 0 for row in steps),
            f"input after the timeout: {scenario.controller.timeout_input}": any(
                row["t_ns"] - max((d["t_ns"] for d in delivered if d["model_t_ns"] <= row["t_ns"]), default=0)
                >= scenario.timing.update_timeout_ns
                for row in outcome.reference["controller_step"]
            ),
            "set point": any(scenario.controller.setpoint or ()),
            "reference": scenario.controller.reference is not None,
            "changes": bool(scenario.changes),
            "acknowledgements": bool(outcome.reference["sensor_acknowledgement"]),
            "updates lost": any(row["dropouts"] > 0 for row in delivered),
            "updates late": any(row["model_t_ns"] > row["t_ns"] for row in delivered),
            "update of the time of a step": any(
                row["model_t_ns"] % scenario.timing.plant_period_ns == 0 for row in delivered
            ),
            "event by comparison": any(r["event"] > 0 and r["is_compared"] for r in measured),
            "event by time": any(row["t_ns"] >= row["due_ns"] for row in measured),
            "actuations or acknowledgements lost": 1 in packets["flow"][packets["release_ns"] < 0],
            "stale": "stale" in rejected_in(random_run(number)),
            "damaged": "tag" in rejected_in(random_run(number)),
        }
        counts.update(feature for feature, is_present in has.items() if is_present)
    assert len(counts) == 25, counts
    assert min(counts.values()) >= (4 if len(draws) == RANDOM else 2), counts


def test_a_tie_ends_the_comparison_of_a_run_and_is_no_difference() -> None:
    """δ becomes the ‖e_s‖ of an event, so that the comparison there is decided by rounding."""
    for number in of_policy("absolute", range(RANDOM)):
        content = random_scenario(number)
        content.pop("changes", None)
        measured = simulate(resolve(validate(content, "random")))["sensor_measurement"]
        later = measured[measured["event"] > 0]
        if not len(later):
            continue
        content["trigger"]["delta"] = float(later["compared"][0])
        if Comparison(simulate(resolve(validate(content, "random")))).tie_ns is not None:
            return
    pytest.fail("no scenario has a tie")


# --- what the paper states ------------------------------------------------------------------------


@DRAWS
@pytest.mark.parametrize("policy", POLICIES)
def test_the_models_differ_by_the_missed_jumps_whatever_the_network_does(
    policy: str, draws: Sequence[int]
) -> None:
    """Check (I1) at every time of an event of the loop, with each term propagated in one step.

    x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻).
    """
    for number in of_policy(policy, draws):
        record = random_run(number)
        scenario = record.scenario
        is_at_0 = scenario.controller.setpoint is None and scenario.controller.reference is None
        if not scenario.protocol.acknowledges and is_at_0:
            # Nothing flows from the controller to the sensor.
            assert "sensor_acknowledgement" not in record.tables
            assert check_identity(record) > 10


def check_identity(record: RunRecord) -> int:
    """Return the number of comparisons."""
    settings, compared = settings_of(record.scenario), 0

    @cache
    def propagation(dt_ns: int) -> Array:
        return np.asarray(expm(settings.H * (dt_ns * 1e-9)))

    measured, deliveries = record["sensor_measurement"], record["controller_delivery"]
    steps = record["controller_step"]
    jumps = [(int(row["t_ns"]), row["x_s"] - row["x"]) for row in measured if row["event"] != NONE]
    growth = max(np.linalg.norm(propagation(t_ns), 2) for t_ns in measured["t_ns"].tolist())
    largest = max(1.0, *(np.abs(rows[name]).max(initial=0.0) for rows, name in (
        (measured, "x_s"), (measured, "x"), (steps, "x_c"), (deliveries, "x_c"),
    )))  # fmt: skip
    for now_ns in np.unique(
        np.concatenate([rows["now_ns"] for rows in (measured, deliveries, steps)])
    ).tolist():
        row, delivery, step = (
            rows[: np.searchsorted(rows["now_ns"], now_ns, "right")][-1:]
            for rows in (measured, deliveries, steps)
        )
        last = max([*step, *delivery], key=lambda row: row["input"], default=None)
        if last is None or not (len(row) and (settings.known_x0 is not None or len(delivery))):
            continue  # no common start of the two models yet
        received = max(deliveries["sequence"][deliveries["now_ns"] <= now_ns], default=NONE)
        x_s = row["x_s" if row["event"][0] == NONE else "x"][0]
        x_s = propagation(now_ns - int(row["t_ns"][0])) @ x_s
        x_c = propagation(now_ns - int(last["model_t_ns"])) @ last["x_c"]
        missed = [
            propagation(now_ns - then_ns) @ e_s for then_ns, e_s in jumps[received + 1 :] if then_ns <= now_ns
        ]
        # Each side takes some hundred propagations, with relative errors of about 1e-15.
        expected = np.sum([0 * x_s, *missed], axis=0)
        np.testing.assert_allclose(x_c - x_s, expected, rtol=0, atol=1e-12 * growth * largest)
        compared += 1
    return compared


def test_only_the_plant_sends_to_the_sensor_and_nobody_accepts_acknowledgements() -> None:
    """Each decoder accepts one flow, even under the run's key."""
    receivers = {role: receiver_of(role, flow) for role, flow in SENDS.items()}
    assert [role for role, receiver in receivers.items() if receiver == "sensor"] == ["plant"]
    assert Flow.ACKNOWLEDGEMENT not in {*RECEIVES.values(), *SENDS.values()}
    key = bytes(32)
    for role in ("plant", "sensor", "controller"):
        for flow in set(Flow) - {RECEIVES[role]}:
            entries = 0 if flow is Flow.ACKNOWLEDGEMENT else 2
            decoder = Decoder(RECEIVES[role], 2, 7, key)
            data = Encoder(7, key).encode(Message(flow, 0, 0, np.zeros(entries)))
            assert decoder.decode(data) is None


def test_the_papers_example_behaves_as_the_paper_states() -> None:
    """Section V: U = −12, M = 5, β = 0.5, α = 0.25; 80 % packet loss without the cap."""
    events, settles_s = {}, {}
    for mode in ("model", "zoh"):
        path = Path(__file__).parents[3] / "scenarios" / "lane_following.toml"
        loop = simulate(resolve(load(path, [f"mode={mode}"])))
        measured, deliveries = loop["sensor_measurement"], loop["controller_delivery"]
        is_event = measured["event"] != NONE
        events[mode] = int(is_event.sum())
        # The longest loss burst has exactly four packets.
        assert loop.notices == []
        assert deliveries["sequence"][0] == 0
        assert deliveries["dropouts"].max() == 4
        assert len(deliveries) < events[mode] / 2  # "most of this transmitted packets are lost"
        # "The state converges": in 20 s the threshold and the state decrease by e^5 = 148.
        size = np.linalg.norm(measured["x"], axis=1)
        assert size[measured["t_ns"] >= 19 * 10**9].max() < 0.03 * size[0]
        settles_s[mode] = measured["t_ns"][np.flatnonzero(size > 0.2 * size[0])[-1]] * 1e-9
    # "ZOH-ET" needs more updates and settles later.
    assert events["zoh"] > 3 * events["model"]
    assert settles_s["zoh"] > settles_s["model"]
