"""The largest share of each certificate's bounds that the worst losses found use, by policy.

The loops are the shipped linear ones, as their processes run them, with the schedule's certificate,
in the norm that ``noack certify --weight chosen`` finds for the paper's trigger.
"""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._report import Benchmark, Goal, Row, say
from cosim.analysis.adversary import Objective, Worst, conditions_of, find_worst
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load, validate
from noack.core.linear_systems import Matrix
from noack.theory.certificates.scenario_certificates import certify
from noack.theory.certificates.weight import choose_weight

SCENARIOS = Path(__file__).parents[1] / "scenarios"
LOOPS = ("lane_following", "double_integrator", "unstable_pendulum", "f16_lateral")
NODES, BEAM = 200_000, 64
_SIGMA, _PERIOD_S, _DEADLINE_S = 0.005, 0.01, 0.02
_ROUNDING = 1 + 1e-9
QUANTITIES = {
    Objective.ERROR: "e_c", Objective.STATE: "x", Objective.INTER_EVENT: "inter-event time",
}  # fmt: skip


def triggers(paper: Mapping[str, Any], weight: Matrix) -> dict[str, dict[str, Any]]:
    """Return the settings of every policy by name; constant thresholds are a fifth of β."""
    W, delta = {"weight": weight.tolist()}, 0.2 * paper["beta"]
    square = weight.T @ weight
    nothing = np.zeros_like(square)
    Q = np.block([[-(_SIGMA**2) * square, nothing], [nothing, square]])
    absolute = {"policy": "absolute", "delta": delta} | W
    deadline = {"policy": "deadline", "interval_s": _DEADLINE_S}
    dynamic = {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.1, "decay_per_s": 1.0}
    found: list[dict[str, Any]] = [
        {"policy": "decaying"} | paper | W,
        absolute,
        {"policy": "relative", "sigma": _SIGMA} | W,
        {"policy": "mixed", "sigma": _SIGMA, "epsilon": delta} | W,
        {"policy": "quadratic", "Q": Q.tolist(), "epsilon": delta**2, "period_s": _PERIOD_S} | W,
        {"policy": "send_on_area", "delta_s": delta * _PERIOD_S} | W,
        {"policy": "periodic", "period_s": _PERIOD_S} | W,
        {"policy": "self_triggered", "growth_per_s": 1.0, "mismatch_per_s": 1.0,
         "shortest_s": _PERIOD_S, "longest_s": _DEADLINE_S} | paper | W,
        deadline | {"rule": absolute},
        {"policy": "dwell", "interval_s": _PERIOD_S, "rule": absolute},
        deadline | {"rule": {"policy": "lyapunov", "rate_per_s": 0.2} | W},
        deadline | {"rule": dynamic | W},
    ]  # fmt: skip
    return {
        one["policy"] + (f"({one['rule']['policy']})" if "rule" in one else ""): one
        for one in found
    }


def loop_named(name: str, horizon_s: float, norm: str) -> Scenario:
    """Return a shipped scenario with the paper's trigger in a norm."""
    resolved = resolve(load(SCENARIOS / f"{name}.toml", [f"horizon_s={horizon_s}"]))
    paper, loop = resolved.decaying, loop_of(resolved)
    weight = np.eye(loop.n)
    if norm == "chosen":
        conditions = conditions_of(resolved, continuous=False)
        weight = choose_weight(loop, paper.beta, paper.alpha_per_s, conditions)
    rows = tuple(map(tuple, weight.tolist()))
    return resolved.model_copy(update={"trigger": paper.model_copy(update={"weight": rows})})


def rows_of(loop: Scenario, policy: str, trigger: Mapping[str, Any]) -> list[Row]:
    """Search one loop under one policy."""
    name = f"{loop.name}, {policy}"
    say(name)
    content = loop.model_dump(mode="json", exclude_none=True) | {"trigger": trigger}
    resolved = resolve(validate(content, name))
    certificate = certify(resolved, conditions_of(resolved, continuous=False))
    if certificate.void is not None:
        return [Row(name, None, "", note=f"no certificate: {certificate.void}")]
    search = partial(find_worst, resolved, most_nodes=NODES, beam=BEAM, certificate=certificate)
    return [row_of(name, search(objective)) for objective in QUANTITIES]


def row_of(name: str, worst: Worst) -> Row:
    """Return the share of a bound that the worst run uses; more than 1 refutes the bound."""
    searched = f"all {worst.runs}" if worst.exact else f"some, {worst.runs} runs"
    return Row(
        f"{name}: {QUANTITIES[worst.objective]}", worst.tightness, "of the bound",
        goal=Goal("<=", _ROUNDING),
        note=f"worst {worst.value}, certified {worst.certified}; patterns searched: {searched}",
    )  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Search every loop under every policy, or the chosen ones."""
    rows: list[Row] = []
    for name in options.loop or LOOPS:
        say(f"{name}: the norm")
        loop = loop_named(name, options.search_s, options.norm)
        paper = loop.decaying.model_dump(include={"beta", "alpha_per_s", "floor"})
        for policy, trigger in triggers(paper, np.array(loop.decaying.weight)).items():
            if policy in (options.policy or (policy,)):
                rows += rows_of(loop, policy, trigger)
    return rows


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--loop", action="append", choices=LOOPS, help="tightness: only this loop")
    parser.add_argument("--policy", action="append", help="tightness: only this policy")
    parser.add_argument("--search-s", type=float, default=5.0, help="tightness: horizon in s")
    parser.add_argument(
        "--norm", choices=("chosen", "identity"), default="chosen", help="tightness: the norm"
    )


BENCHMARK = Benchmark("tightness", "The adversary against the certificates", measure, _arguments)
