"""What a proof says of a run, as arrays, and as a certificate that the adversary attacks."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack_check.proof import Proof


def proven_limit(proof: Proof, output: str, t_s: Vector) -> Vector:
    """Return the smallest proven bound of an output at times, (k,); infinite without one."""
    limit = np.full(len(t_s), np.inf)
    for bound in proof.bounds:
        if bound.output == output and bound.from_start:
            decaying = float(bound.decaying.mid()) * np.exp(-float(proof.rate.mid()) * t_s)
            limit = np.minimum(limit, decaying + float(bound.constant.mid()))
    return limit


def sizes_of(record: RunRecord) -> Iterator[tuple[str, Vector, Vector]]:
    """Yield x at the plant's steps, and e_s = x_s − x at the measurements: times and norms, (k,).

    The recorded norm is that of x_s minus what was measured or estimated.
    """
    loop = loop_of(record.scenario)
    W = np.eye(loop.n) if loop.weight is None else loop.weight
    steps, measured = record[PLANT_STEP], record[SENSOR_MEASUREMENT]
    x_r = 0.0 if loop.reference is None else loop.reference.state(0)
    yield "x", steps["t_ns"] / NS_PER_S, np.linalg.norm(steps["x"] - x_r, axis=1)
    measured = measured[np.isin(measured["t_ns"], steps["t_ns"])]
    x = steps["x"][np.searchsorted(steps["t_ns"], measured["t_ns"])]
    yield "e_s", measured["t_ns"] / NS_PER_S, np.linalg.norm((measured["x_s"] - x) @ W.T, axis=1)


def with_proven_bounds(
    certificate: ScenarioCertificate, proof: Proof, resolved: Scenario
) -> ScenarioCertificate:
    """Return a certificate whose bounds are the proven ones, D₁ e^{−rt} + D₂."""
    level = max(certificate.beta, certificate.floor if float(proof.rate.mid()) == 0 else 0.0) or 1.0

    def constants(part: int, unit: float) -> Constants:
        sizes = {}
        for bound in proof.bounds:
            if bound.from_start:
                size = float((bound.decaying, bound.constant)[part].mid()) * (1 + 1e-9)
                both = float((bound.decaying + bound.constant).mid())
                if both <= sizes.get(bound.output, (math.inf, 0.0))[0]:
                    sizes[bound.output] = (both, size)
        value = {output: size for output, (_, size) in sizes.items()}
        apart = None if proof.inter_event is None else float(proof.inter_event.mid()) or None
        return Constants(
            rate_per_s=float(proof.rate.mid()) if part == 0 else 0.0,
            missing_events=resolved.network.mansd + 1,
            delta=value.get("e_c", math.inf) / unit,
            overshoot=value.get("e_s", math.inf) / unit,
            input_error=math.inf,
            start_error=math.inf,
            state=value.get("x", math.inf),
            state_weighted=math.inf,
            mismatch=math.inf,
            inter_event_s=apart,
            loop_gain=0.0,
        )

    persistent = constants(1, 1.0)
    return replace(
        certificate,
        constants=constants(0, level),
        persistent_constants=persistent if persistent.state or persistent.overshoot else None,
        floor_constants=None,
        other=None,
        void=None,
    )
