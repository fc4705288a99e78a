"""The record of a run in deviations from its reference or set-point, and what its first inputs differ by.

At a set-point x_r certificates bound x − x_r, x_s − x_r, x_c − x_r and u − u_r. Until the plant
applies the first input of the controller, u is 0 and not u_r: ‖u − Kx‖ is recorded, and the
certificate holds if it covers input errors of this size; see ``CertificateScope`` in
:mod:`noack.theory.certificates.scenario_certificates`.
"""

from cosim.record.run_record import Rows, RunRecord
from noack.core.references import Reference
from noack.protocol.record_tables import SETTINGS
from noack.theory.certificates.conditions import about_reference

_STATES = ("x", "x_s", "x_c", "x_c_before", "x_s_before")


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
        about_reference(scenario).model_copy(update={"changes": ()}),
        derive,
    )
