"""Certificates in the Python API."""

import json

import pytest

import noack


def test_a_system_is_certified(scenario: noack.Scenario) -> None:
    found = noack.certify(scenario)
    for certificate in (found.paper, found.schedule):
        assert certificate.void is None
        assert certificate.constants is not None
        assert certificate.constants.delta >= 1
        assert certificate.constants.state >= 0.2
        assert certificate.inter_event_s is not None
    assert found.paper_box is None
    assert found.schedule_box is None
    assert found.limits.sampling_s > 0.002
    assert found.theorem_2 is not None
    assert found.weight is None
    assert json.loads(json.dumps(found.to_json()))["scenario"] == "own_system"


def test_the_box_is_certified_and_shown(scenario: noack.Scenario) -> None:
    box = {"plant.uncertainty_A": [[0.0, 0.0], [0.3, 0.1]]}
    found = noack.certify(noack.with_settings(scenario, box), late=0)
    assert found.paper_box is not None
    assert found.schedule_box is not None
    assert found.paper_box.constants is not None
    for shown in (repr(found), found._repr_html_()):
        assert "schedule, box" in shown
        assert f"{found.paper_box.constants.delta:.4g}" in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"weight": "best"}, 'weight: given, identity or chosen, not "best"'),
        ({"late": -1}, "late: -1 steps; give 0 to 1000"),
    ],
)
def test_what_cannot_be_asked_is_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(noack.NoackError) as caught:
        noack.certify("double_integrator", **options)  # type: ignore[arg-type]
    assert str(caught.value) == message


def test_a_missing_certificate_gives_one_line() -> None:
    with pytest.raises(noack.NoackError, match="the plant is not linear"):
        noack.certify("cart_pole")
