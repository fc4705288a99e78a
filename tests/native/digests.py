"""Prints digests of what the core computes: records of the shipped scenarios, exact batches, and
functions. ``test_same_bits.py`` compares those of cores that were built in different ways, and with
the argument ``linear`` those that no other library computes."""

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from cosim.shipped_files import find_shipped, shipped_names
from cosim.simulation.exact_simulation import run_with_events
from cosim.simulation.virtual_time import simulate
from netem.core.core_library import core as network_core
from netem.core.errors import CallerError
from noack.core.core_library import core
from noack.core.linear_systems import exponential
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.simulation.exact_populations import random_population, random_setting
from tests.helpers.example_rules import TABLES, random_rule

LANES = ("following", "acknowledged", "actuation_loss", "crosswind")
"""Of the scenarios of the lane, those with machines of their own."""
LINEAR = ("lane_following", "f16_lateral", "unstable_pendulum")
"""Scenarios whose matrices and machines are all noack's."""
FUNCTIONS = ("exp", "expm1", "log", "cube_root", "normal_cdf", "normal_score")


def _print(name: str, *parts: bytes) -> None:
    print(name, hashlib.sha256(b"".join(parts)).hexdigest(), flush=True)


def _records(names: Iterable[str]) -> None:
    for name in names:
        if name.startswith("lane_") and name.removeprefix("lane_") not in LANES:
            continue
        try:
            record = simulate(resolve(load(find_shipped(name, "scenarios"), ["horizon_s=1"])))
        except CallerError:  # several loops, or a plant that needs an extra
            continue
        for table in sorted(record.tables):
            rows = record[table]
            for column in rows.dtype.names or ():
                _print(f"{name} {table} {column}", rows[column].tobytes())


def _batches() -> None:
    """The paper's trigger with vectors of every size, and each policy with two states."""
    for policy, n in [*(("", n) for n in (1, 2, 3, 4, 7, 20)), *((name, 2) for name in TABLES)]:
        rng = np.random.default_rng(n)
        setting = random_setting(rng, n, 2)
        trigger = setting.trigger
        if policy:
            trigger = random_rule(policy, rng, n, trigger.weight)
        setting = replace(setting, trigger=trigger, most_events=100)
        rows, events = run_with_events(setting, random_population(rng, setting, 3))
        times = (run.event_s.tobytes() for run in events)
        _print(f"batch {policy} n={n}", rows.tobytes(), *times)


def _functions() -> None:
    rng = np.random.default_rng(1)
    numbers = np.concatenate([rng.normal(0, scale, 5000) for scale in (0.01, 1.0, 300.0)])
    for name in FUNCTIONS:
        function = getattr(network_core, f"noack_{name}")
        arguments = rng.uniform(0, 1, 15000) if name == "normal_score" else numbers
        _print(name, np.array([function(x) for x in arguments.tolist()]).tobytes())


def _exponentials() -> None:
    rng = np.random.default_rng(3)
    for n in (1, 2, 4, 9, 16):
        for scale in (1e-6, 0.1, 1.0, 30.0):
            _print(f"exponential {n} {scale}", exponential(scale * rng.normal(size=(n, n))).tobytes())


if __name__ == "__main__":
    _exponentials()
    if sys.argv[1:] == ["linear"]:
        _records(LINEAR)
    else:
        _records(shipped_names("scenarios"))
        print("instructions:", core.noack_exact_instructions())
        _batches()
        _functions()
