"""Which loops the paper's identities and exact simulation cover."""

import pytest

from cosim.analysis.certificates import certificates_of
from cosim.analysis.claims.run_certificates import scheduled_certificates
from netem.core.errors import CallerError
from noack.theory.coverage import is_papers_loop, nonlinear_because, require_exact
from tests.helpers.shipped import resolved, shipped

PYTHON = 'kind="python", name="a:B"'
CHANGES = 'changes=[{at_s=1.0, set={"network.mansd"=1}}]'
SINE = 'plant.disturbances=[{kind="sine", amplitude=[0.1], hz=1.0}]'


@pytest.mark.parametrize(
    ("settings", "key", "is_linear", "is_papers"),
    [
        (f"controller={{{PYTHON}}}", "controller.kind", False, False),
        ("controller.update_timeout_s=1.0", "controller.update_timeout_s", False, False),
        ("network.protocol=ack", "network.protocol", False, False),
        (f'trigger={{policy="python", {PYTHON.split(", ")[1]}}}', "trigger.policy", False, False),
        ("network.actuation={mansd=1}", "network.actuation", True, True),
        (SINE, "plant.disturbances.kind", True, True),
        ("plant.measurement.noise_std=[0.1, 0.0]", "plant.measurement", True, True),
        ('observer={kind="luenberger", poles_per_s=[-3, -4]}', "observer.kind", True, True),
        (
            "controller.reference=[{kind='step', output='position', value=1.0, from_s=0.0}]",
            "controller.reference",
            True,
            True,
        ),
        ("network.initial_sync=known_state", "", True, True),
        ('trigger={policy="deadline", interval_s=1.0, rule={policy="absolute", delta=0.1}}', "", True, True),
    ],
)
def test_what_is_not_covered_is_refused_by_its_key(
    settings: str, key: str, is_linear: bool, is_papers: bool
) -> None:
    scenario = resolved("double_integrator", settings)
    assert (nonlinear_because(scenario) is None) == is_linear
    assert is_papers_loop(scenario) == is_papers
    if not key:
        require_exact(scenario)
        return
    with pytest.raises(CallerError, match=rf"^{key}.*: .* this needs a "):
        require_exact(scenario)


def test_a_plant_by_its_equations_is_the_papers_loop_and_not_linear() -> None:
    scenario = resolved("sine_pendulum")
    assert is_papers_loop(scenario)
    assert (nonlinear_because(scenario) or "").startswith('plant.system.kind = "python": ')


def test_changes_are_refused_before_a_run_and_not_in_it() -> None:
    with pytest.raises(CallerError, match=r"^changes: .*leave changes out"):
        certificates_of(shipped("double_integrator", CHANGES))
    assert scheduled_certificates(resolved("double_integrator", CHANGES))[0].certificate.exists


@pytest.mark.parametrize(
    "settings",
    [
        (
            "description='another text'",
            "model.state_names=['position','v']",
            "speed=2.0",
            "start_within_s=9.0",
        ),
        ("plant.disturbances.0.hz=9.0", "plant.disturbances.0.phase_rad=1.0"),
        ("network.limit=50", "network.encrypted=true", "controller.timeout_input=safe"),
        ("realtime.enabled=false", "clocks={largest_error_us=50.0}", "ports.sensor=4000"),
        ("seeds.loss=5", "seeds.disturbance=6", "seeds.noise=7"),
    ],
)
def test_what_the_checkers_table_calls_irrelevant_changes_no_certificate(settings: tuple[str, ...]) -> None:
    before, after = (
        [each.certificate.to_json() for each in scheduled_certificates(resolved("double_integrator", *given))]
        for given in ((SINE,), (SINE, *settings))
    )
    assert before == after
