"""What the benchmark of the certificates judges: a missing one, and a loose bound of e_c."""

from benchmarks.cases.guarantees import loop_named, smallest_share, tightness_rows
from benchmarks.report import Row


def test_a_missing_certificate_fails() -> None:
    loop = loop_named("double_integrator", 1.0, "identity")
    (row,) = tightness_rows(loop, "relative", {"policy": "relative", "sigma": 5.0})
    assert row.name == "double_integrator, relative: certificates"
    assert row.holds is False
    assert row.note


def test_a_loose_bound_of_the_error_fails() -> None:
    rows = [
        Row("a: e_c", 0.9, ""),
        Row("a: x", 0.1, ""),
        Row("b: e_c", 0.45, ""),
        Row("c: certificates", 0, ""),
    ]
    assert smallest_share(rows).value == 0.45
    assert smallest_share(rows).note == "b: e_c"
    assert smallest_share(rows).holds is False
    assert smallest_share(rows[:2]).holds is True
    assert smallest_share(rows[1:2]).holds is None
