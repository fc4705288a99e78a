"""What is guaranteed: losses over very many decisions, and certificates beside attacks."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import ZERO, Goal, MeasurementError, Peer, Row, announce, benchmark
from cosim.analysis.adversary import Objective, WorstRun, find_worst
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.cli.options import find_scenario
from netem.link_state import LinkState
from netem.tc_words import settings_of
from noack.core.linear_systems import Matrix
from noack.impairments.target_loss import expected_loss
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load, validate
from noack.theory.trigger_norm import input_norm
from tests.oracles.loss_language import is_allowed, longest_burst, outcomes_of

DECISIONS = 100_000_000
_FLOW_DECISIONS = 1_000_000
REORDERING = "delay 5ms 5ms reorder 20% duplicate 5% corrupt 5%"
COMBINATIONS = (
    "mansd 4",
    "atmost 3 in 10",
    "atmost 20 in 100",
    "mansd 4 recover 3",
    "mansd 2 atmost 3 in 10 recover 2",
)
CAP = 3
_LOSS, _DELAY = "loss 30%", "delay 10ms 10ms distribution normal reorder 10% limit 1000000"
_SPACING_NS = 2_000_000
"""Time between two packets."""


def decide(words: str, flow: int = 0, spacing_ns: int = 10_000) -> NDArray[Any]:
    """Return the decisions for the datagrams of a flow, ``spacing_ns`` apart."""
    link, count = LinkState(settings_of(words), 7, "relay", "forward"), _FLOW_DECISIONS
    link.start_flow(0, flow)
    return link.decide_many(np.zeros(count, np.int64), np.full(count, 72), np.arange(count) * spacing_ns)


def check_rows(impairments: str, guarantee: str, count: int) -> Iterator[Row]:
    """Yield the flows with a violation in ``count`` decisions, and the loss rate if it can be predicted."""
    words, guarantee_settings = f"{impairments} {guarantee}", settings_of(guarantee)
    announce(f"{count:,} decisions, {words}")
    numbers = range(count // _FLOW_DECISIONS)
    flows = [outcomes_of(decide(f"{words} limit 1000000", flow)) for flow in numbers]
    number = sum(not is_allowed(lost, guarantee_settings) for lost in flows)
    yield Row(f"{words}: flows with a violation", number, "", goal=ZERO, note=f"{count:,} decisions")
    if "delay" not in words and (predicted_rate := expected_loss(settings_of(words)).rate):
        yield Row(f"{words}: lost", 100 * float(np.mean(flows)), "%", Peer("predicted", 100 * predicted_rate))


def network_rows() -> Iterator[Row]:
    """Yield the losses at the receiver of three networks with the same random numbers."""
    cap = f"mansd {CAP}"
    capped = decide(_DELAY, spacing_ns=_SPACING_NS)
    capped["release_ns"][decide(f"{_LOSS} {cap}", spacing_ns=_SPACING_NS)["release_ns"] < 0] = -1
    networks = {
        "no cap": decide(f"{_LOSS} {_DELAY}", spacing_ns=_SPACING_NS),
        f"cap {CAP} on drops only": capped,
        cap: decide(f"{_LOSS} {_DELAY} {cap}", spacing_ns=_SPACING_NS),
    }
    for name, decisions in networks.items():
        lost, dropped = outcomes_of(decisions), decisions["release_ns"] < 0
        goal = Goal("<=", CAP) if name == cap else None
        yield Row(f"{name}: dropped", 100 * float(dropped.mean()), "%")
        yield Row(f"{name}: dropped or out of order", 100 * float(lost.mean()), "%")
        yield Row(f"{name}: longest loss burst", longest_burst(lost), "", goal=goal)
    back_ns = networks[cap]["hold_back_ns"]
    back_ns = back_ns[back_ns > 0]
    yield Row(f"{cap}: held back", 100 * len(back_ns) / _FLOW_DECISIONS, "%")
    yield Row(f"{cap}: held back by, median", float(np.median(back_ns)) / 1e6, "ms")


@benchmark("guarantee", "Emulator: the guarantee over many decisions")
def guarantee() -> Iterator[Row]:
    """Measure networks, then violations and loss rates over very many decisions.

    A check that uses nothing of netem looks for violations at the receiver, a million datagrams per
    flow: a datagram counts as lost if it is dropped, or if a later one arrives before it. A cap on
    drops only forces a datagram after m drops, and leaves the delays as they are.
    """
    yield from network_rows()
    for constraint in COMBINATIONS:
        for before in ("loss 50%", f"loss 30% {REORDERING}"):
            yield from check_rows(before, constraint, DECISIONS)


LOOPS = ("lane_following", "double_integrator", "unstable_pendulum", "f16_lateral")
MOST_NODES, BEAM = 200_000, 64
_SIGMA, _PERIOD_S, _DEADLINE_S = 0.005, 0.01, 0.02
_ROUNDING = 1 + 1e-9
QUANTITIES = {Objective.ERROR: "e_c", Objective.STATE: "x", Objective.INTER_EVENT: "inter-event time"}


def triggers(paper: dict[str, Any], weight: Matrix) -> dict[str, dict[str, Any]]:
    """Return the settings of every policy by name; constant thresholds are a fifth of β."""
    W, delta = {"weight": weight.tolist()}, 0.2 * paper["beta"]
    square = weight.T @ weight
    zero = np.zeros_like(square)
    Q = np.block([[-(_SIGMA**2) * square, zero], [zero, square]])
    absolute = {"policy": "absolute", "delta": delta} | W
    deadline = {"policy": "deadline", "interval_s": _DEADLINE_S}
    dynamic = {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.1, "decay_per_s": 1.0}
    self_triggered = {"policy": "self_triggered", "growth_per_s": 1.0, "mismatch_per_s": 1.0}
    rules: list[dict[str, Any]] = [
        {"policy": "decaying"} | paper | W,
        absolute,
        {"policy": "relative", "sigma": _SIGMA} | W,
        {"policy": "mixed", "sigma": _SIGMA, "epsilon": delta} | W,
        {"policy": "quadratic", "Q": Q.tolist(), "epsilon": delta**2, "period_s": _PERIOD_S} | W,
        {"policy": "send_on_area", "delta_s": delta * _PERIOD_S} | W,
        {"policy": "periodic", "period_s": _PERIOD_S} | W,
        self_triggered | {"shortest_s": _PERIOD_S, "longest_s": _DEADLINE_S} | paper | W,
        deadline | {"rule": absolute},
        {"policy": "dwell", "interval_s": _PERIOD_S, "rule": absolute},
        deadline | {"rule": {"policy": "lyapunov", "rate_per_s": 0.2} | W},
        deadline | {"rule": dynamic | W},
    ]
    return {row["policy"] + (f"({row['rule']['policy']})" if "rule" in row else ""): row for row in rules}


def loop_named(name: str, horizon_s: float, norm: str) -> Scenario:
    """Return a shipped scenario with the paper's trigger in a norm, "input" or "identity"."""
    resolved = resolve(load(find_scenario(name), [f"horizon_s={horizon_s}"]))
    paper, loop = resolved.decaying, loop_of(resolved)
    weight = np.eye(loop.n)
    if norm == "input":
        weight = input_norm(loop.H, loop.K, paper.alpha_per_s)
    rows = tuple(map(tuple, weight.tolist()))
    return resolved.model_copy(update={"trigger": paper.model_copy(update={"weight": rows})})


def tightness_rows(loop: Scenario, policy: str, trigger: Mapping[str, Any]) -> Iterator[Row]:
    """Search one loop under one policy."""
    name = f"{loop.name}, {policy}"
    announce(name)
    content = loop.model_dump(mode="json", exclude_none=True) | {"trigger": trigger}
    resolved = resolve(validate(content, name))
    certificate = quick_certificate(resolved)
    if not certificate.exists:
        yield Row(f"{name}: certificates", 0, "", goal=Goal("==", 1), note=certificate.void)
        return
    search = partial(find_worst, resolved, most_nodes=MOST_NODES, beam=BEAM, certificate=certificate)
    yield from (row_of(name, search(objective)) for objective in QUANTITIES)


def row_of(name: str, worst: WorstRun) -> Row:
    """Return the share of a bound that the worst run uses; more than 1 refutes the bound."""
    patterns = f"all {worst.runs}" if worst.exact else f"some, {worst.runs} runs"
    return Row(
        f"{name}: {QUANTITIES[worst.objective]}",
        worst.tightness,
        "of the bound",
        goal=Goal("<=", _ROUNDING),
        note=f"worst {worst.value}, certified {worst.certified}; patterns searched: {patterns}",
    )


@benchmark("tightness", "The adversary against the certificates")
def tightness(loop: str = "", policy: str = "", search_s: float = 5.0, norm: str = "input") -> Iterator[Row]:
    """Search the largest share of each certificate's bounds that the worst losses use, by policy.

    The bounds are those that need no search; the norm counts errors by what they do to u.
    """
    if norm not in ("input", "identity"):
        raise MeasurementError(f"no norm {norm}: input, or identity")
    for name in (loop,) if loop else LOOPS:
        announce(f"{name}: the norm")
        scenario = loop_named(name, search_s, norm)
        paper = scenario.decaying.model_dump(include={"beta", "alpha_per_s", "floor"})
        for rule, trigger in triggers(paper, np.array(scenario.decaying.weight)).items():
            if policy in ("", rule):
                yield from tightness_rows(scenario, rule, trigger)
