"""What a proof says of a run, as arrays."""

from collections.abc import Iterator

import numpy as np
import scipy.linalg

from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from noack.core.linear_systems import Vector
from noack.proof.search.results import Proof
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import loop_of


def proven_limit(proof: Proof, output: str, t_s: Vector) -> Vector:
    """Return the smallest proven bound of an output at times, (k,); infinite without one."""
    limit = np.full(len(t_s), np.inf)
    for bound in proof.bounds:
        if bound.output == output and bound.from_start:
            decaying = float(bound.decaying.mid()) * np.exp(-float(proof.rate.mid()) * t_s)
            limit = np.minimum(limit, decaying + float(bound.constant.mid()))
    return limit


def sizes_of(record: RunRecord, rest: Vector) -> Iterator[tuple[str, Vector, Vector]]:
    """Yield x, its entries and the outputs at the plant's steps, e_s at measurements, e_c at steps.

    Each with its times and sizes, (k,). ``rest``: (n,), from where x counts. The recorded norm of e_s is that
    of x_s minus what was measured or estimated.
    """
    loop = loop_of(record.scenario)
    W = np.eye(loop.n) if loop.weight is None else loop.weight
    steps, measured, ticks = record[PLANT_STEP], record[SENSOR_MEASUREMENT], record[CONTROLLER_STEP]
    t_s, x = steps["t_ns"] / NS_PER_S, steps["x"] - rest
    yield "x", t_s, np.linalg.norm(x, axis=1)
    rows = {"x": np.eye(loop.n), "y": np.array([output.row for output in loop.outputs])}
    for kind, C in rows.items():
        for index, row in enumerate(C):
            yield f"{kind}[{index}]", t_s, np.abs(x @ row)
    measured = measured[np.isin(measured["t_ns"], steps["t_ns"])]
    error = measured["x_s"] - steps["x"][np.searchsorted(steps["t_ns"], measured["t_ns"])]
    yield "e_s", measured["t_ns"] / NS_PER_S, np.linalg.norm(error @ W.T, axis=1)
    delivered = record[CONTROLLER_DELIVERY]["now_ns"]
    if record.scenario.network.initial_sync != "known_state":  # before, x_c is not known
        ticks = ticks[ticks["now_ns"] > (delivered[0] if len(delivered) else np.inf)]
    newest = np.searchsorted(ticks["model_t_ns"], steps["t_ns"], side="right") - 1
    t_s, x, ticks = t_s[newest >= 0], x[newest >= 0], ticks[newest[newest >= 0]]
    ages_s = t_s - ticks["model_t_ns"] / NS_PER_S  # x_c goes on from the newest tick
    predictions = {age_s: scipy.linalg.expm(loop.H * age_s) for age_s in np.unique(ages_s)}
    x_c = [predictions[age_s] @ state for age_s, state in zip(ages_s, ticks["x_c"] - rest, strict=True)]
    yield "e_c", t_s, np.linalg.norm((np.array(x_c).reshape(x.shape) - x) @ W.T, axis=1)
