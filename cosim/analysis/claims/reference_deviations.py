"""The record of a run in deviations from its reference or set-point, and what its first inputs differ by.

At a set-point x_r certificates bound x − x_r, x_s − x_r, x_c − x_r and u − u_r. Until the plant
applies the first input of the controller, u is 0 and not u_r: ‖u − Kx‖ is recorded, and the
certificate holds if it covers input errors of this size; see ``CertificateScope`` in
:mod:`noack.theory.certificates.scenario_certificates`.
"""

import math

import numpy as np

from cosim.record.align import Reals
from cosim.record.run_record import Rows, RunRecord
from noack.core.references import Reference
from noack.core.row_operations import row_norms
from noack.protocol.record_tables import PLANT_STEP, SETTINGS
from noack.scenario.resolution import policy_of
from noack.theory.bounds.disturbances import bound_forcing
from noack.theory.bounds.enclosure import factors
from noack.theory.certificates.conditions import about_reference

_STATES = ("x", "x_s", "x_c", "x_c_before", "x_s_before")
_ROUNDED = 1e-9
"""Share of an input outside of the range of K that is rounding."""


def deviations(record: RunRecord, reference: Reference) -> RunRecord:
    """Return the record of a run in deviations from its reference, without changes of settings."""
    scenario = record.scenario

    def derive(table: str, rows: Rows) -> Rows:
        shifted = (rows[:0] if table in SETTINGS else rows).copy()
        names = shifted.dtype.names or ()
        if not {*names} & {*_STATES, "u"}:
            return shifted
        measured = reference.rows(shifted["t_ns"])
        of_model = reference.rows(shifted["model_t_ns"]) if "model_t_ns" in names else measured
        for name in names:
            if name in _STATES:
                shifted[name] -= (measured if name == "x" else of_model)[:, : reference.n]
            elif name == "u":
                shifted[name] -= of_model[:, reference.n :]
        return shifted

    return record.derived(
        about_reference(scenario, scenario.certificate.late_periods).model_copy(update={"changes": ()}),
        derive,
    )


def start_error(record: RunRecord, started_s: float) -> float:
    """sup‖u − Kx‖ e^{αt} over the steps until the plant applied the first input of the controller.

    u is constant within a step. So ‖u − Kx‖ is at most the larger of its values at both ends, plus
    a term for the curvature of x: Δt²/8 sup‖K ẍ‖, with ẍ = A e^{As}(Ax + Bu + Dw), w constant.
    Infinite: u is not in the range of K, in which the bounds have it. It may be outside if K has
    fewer independent rows than there are inputs, and u was that of a set-point with another u_r; or
    u is not finite, or not recorded at each of these steps.
    """
    alpha = policy_of(record.scenario).fading_per_s
    period_ns = record.scenario.timing.plant_period_ns
    before_ns = -period_ns
    largest, last = 0.0, np.zeros(0, record.tables[PLANT_STEP])
    for batch in record.batches(PLANT_STEP):
        steps = np.concatenate([last, batch])
        ended = int(np.searchsorted(steps["t_ns"] * 1e-9, started_s)) + 1
        if (np.diff(steps["t_ns"][:ended], prepend=before_ns) > period_ns).any():
            return math.inf
        if len(steps[:ended]) > 1:
            largest = max(largest, _input_error(record, steps[:ended], alpha))
        if ended < len(steps):
            break
        last = steps[-1:]
        before_ns = int(last["t_ns"][0]) if len(last) else before_ns
    return max(largest, float(np.finfo(float).tiny))  # 0 would be that of a run from its start


def _input_error(record: RunRecord, steps: Rows, alpha_per_s: float) -> float:
    """Return the bound of ‖u − Kx‖ e^{αt} over at least two steps."""
    loop = record.loop
    x, u, dt_s = steps["x"], steps["u"][:-1], record.scenario.timing.plant_period_ns * 1e-9
    basis, _ = factors(loop.K)
    outside = row_norms(u - u @ basis @ basis.T)
    if (outside > _ROUNDED * (row_norms(u) + row_norms(x[:-1] @ loop.K.T))).any():
        return math.inf
    ends = np.maximum(row_norms(u - x[:-1] @ loop.K.T), row_norms(u - x[1:] @ loop.K.T))
    largest = float(
        ((ends + _bend(record, x[:-1], u, dt_s)) * np.exp(alpha_per_s * steps["t_ns"][1:] * 1e-9)).max()
    )
    return math.inf if math.isnan(largest) else largest


def _bend(record: RunRecord, x: Reals, u: Reals, dt_s: float) -> Reals:
    """Return Δt²/8 sup‖KAẋ‖ within each step of a linear plant."""
    loop = record.loop
    speed = x @ loop.A.T + u @ loop.B.T
    # ‖KA e^{As} ẋ‖ is at most ‖KA ẋ‖ + ‖KA‖ ‖e^{As} − I‖ ‖ẋ‖.
    gain = loop.K @ loop.A
    turned = float(np.linalg.norm(gain, 2)) * math.expm1(min(float(np.linalg.norm(loop.A, 2)) * dt_s, 700.0))
    forced, forcing = 0.0, bound_forcing(record.scenario, loop.B)
    if forcing is not None:
        sizes = np.linalg.norm(gain @ forcing.limited, axis=0)
        forced = float((sizes + turned * np.linalg.norm(forcing.limited, axis=0)).sum())
    return dt_s**2 / 8 * (row_norms(speed @ gain.T) + turned * row_norms(speed) + forced)
