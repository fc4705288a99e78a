"""What the lab says of a scenario's certificate, against what noack says."""

import noack
from noack_lab.results import guarantee_of


def test_the_lab_gives_the_answer_of_certify() -> None:
    """The model of the cart-pole has a certificate, the cart-pole has none; the car has its own."""
    for name in ("lane_following", "cart_pole", "kinematic_car", "lane_periodic"):
        scenario = noack.load(name)
        answer, line = noack.certify(scenario, search=False).answer, guarantee_of(scenario).line
        assert line.text.startswith(answer.text)
        assert line.tone == ("good" if answer.is_certified else "doubt")


def test_bounds_with_a_floor_or_disturbances_do_not_decay_to_zero() -> None:
    for name, stays in (("lane_following", False), ("unstable_pendulum", True), ("servo_reference", True)):
        text = guarantee_of(noack.load(name)).line.text
        assert "all errors decay at" in text
        assert ("to a bound that does not decay" in text) == stays


def test_a_setting_without_a_certificate_is_the_reason_once() -> None:
    text = guarantee_of(noack.load("model_predictive")).line.text
    assert text == 'no certificate: controller.kind = "python": the input is not K x_c'
