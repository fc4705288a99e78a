"""From a plant to a scenario: models, gains, and files that every command accepts."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from scipy.linalg import solve_continuous_are

import noack
from cosim.analysis.certificates import Certificates
from cosim.studies.new_loop import choose, new_scenario
from cosim.studies.new_loop.choices import Choices
from cosim.studies.new_loop.linear_model import controllable_states
from cosim.studies.new_loop.trial_scenario import scenario_of
from cosim.studies.new_loop.trials import LoopTrial
from netem.core.errors import CallerError
from noack.plants.systems import linearisation
from noack.scenario.outputs import LoopOutput
from noack.scenario.resolution import loop_of, resolve
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from tests.helpers.approved import compare_lines
from tests.helpers.command_line import invoke
from tests.helpers.pages import blocks

POLE = '''
import math

class Pole:
    """A pole on a cart."""

    def __init__(self, length_m=0.5):
        self.length_m = length_m

    def derivative(self, t_s, z, u):
        position, velocity, angle, rate = map(float, z)  # so it has no enclosure
        sine, cosine = math.sin(angle), math.cos(angle)
        push = u[0] + 0.1 * self.length_m * sine * rate**2 - 0.1 * 9.81 * sine * cosine
        acceleration = push / (1 + 0.1 * sine**2)
        return velocity, acceleration, rate, (9.81 * sine - cosine * acceleration) / self.length_m

class Unreachable:
    def derivative(self, t_s, z, u):
        return z[0], u[0] - z[1]

class Weighed:
    """x = 0, u = 0 is no equilibrium."""

    def derivative(self, t_s, z, u):
        return z[1], u[0] - 9.81

class Sticking:
    """Dry friction as a sign; math.copysign is not 0 at 0."""

    def derivative(self, t_s, z, u):
        return z[1], u[0] - z[1] - math.copysign(0.5, z[1])

class Nameless:
    allowed = {"position": 0.1}

    def derivative(self, t_s, z, u):
        return z[1], u[0]

class Swinging:
    """Nothing moves it."""

    def derivative(self, t_s, z, u):
        return z[1], 0.0 * u[0] - z[0]

class Heavy:
    """A force of 1 N hardly moves it."""

    states = ["speed, m/s"]
    initial_state = [1.0]

    def derivative(self, t_s, z, u):
        return ((u[0] - 20.0 * z[0]) / 1000.0,)

class Broken:
    def derivative(self, t_s, z, u):
        return nothing

class Endless:
    def derivative(self, t_s, z, u):
        return float("nan"), u[0] + z[1]

class Stepped:
    """A discrete simulator: ẋ = −2 x + u, exactly."""

    def start(self, x0):
        self.x = x0

    def advance(self, u, t_s, dt_s):
        a = math.exp(-2.0 * dt_s)
        self.x = a * self.x + (1 - a) / 2 * u
'''


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(linearisation, "_SAMPLES", {"derivative": 100, "motion": 10})
    Path("pole.py").write_text(POLE)
    Path("classless.py").write_text("mass_kg = 1.0\n")
    return tmp_path


def command(*words: str, ok: bool = True) -> Result:
    result = invoke(*words)
    assert (result.exit_code == 0) == ok, result.output
    return result


def test_three_commands_lead_from_a_class_to_a_certified_run() -> None:
    command("linearise", "pole.py:Pole", "--out", "pole.json")
    command("gain", "pole.json", "--r", "2", "--out", "pole.json")
    text = command("new", "pole.json", "--out", "loop.toml").stdout
    assert "Certified for the linear plant ẋ = Âx + B̂u, for every pattern of losses with at most " in text
    document = json.loads(Path("pole.json").read_text())
    expected = [[0, 1, 0, 0], [0, 0, -0.981, 0], [0, 0, 0, 1], [0, 0, 21.582, 0]]
    np.testing.assert_allclose(document["A"], expected, rtol=1e-9)
    np.testing.assert_allclose(document["B"], [[0], [1], [0], [-2]], rtol=1e-9)
    loop = loop_of(resolve(noack.load("loop.toml")))
    assert loop.K.tolist() == document["gain"]
    command("check", "loop.toml")
    run = noack.simulate(noack.load("loop.toml", {"horizon_s": 2.0}))
    assert run.ok
    assert run.replay().bit_exact
    # With its linear plant the claims of the certificate are checked, and hold.
    linear = noack.simulate(noack.load("loop.toml", {"plant.system": {"kind": "linear"}}))
    assert linear.ok
    assert re.search(r"claims +\d+ held$", repr(linear), re.MULTILINE)
    command("new", "pole.json", "--out", "loop.toml", ok=False)  # it exists


@pytest.mark.usefixtures("short_searches")
@pytest.mark.parametrize(
    "name",
    [
        "cart_pole",
        pytest.param("quadrotor", marks=pytest.mark.deep),  # takes a minute
        pytest.param("dc_motor", marks=pytest.mark.deep),
        pytest.param("four_tank", marks=pytest.mark.deep),
        "unstable_pendulum",
    ],
)
def test_each_plant_of_noack_gets_a_scenario(name: str) -> None:
    made = noack.new(name, "made.toml")
    made.save("made.toml")
    assert noack.load("made.toml") == made.scenario
    command("check", "made.toml")
    if name == "dc_motor":  # an eigenvalue of −1.5e6 /s
        assert made.certificate is None
        assert "No certificate was found" in made.text
    else:
        assert made.certificate is not None
        assert made.certificate.has("x")
    assert made.notes[-1].endswith("the loop returns to 0.")
    assert noack.simulate(noack.load("made.toml", {"horizon_s": 0.5})).ok


def test_a_loop_that_is_not_certified_with_the_fewest_losses_is_not_tried_with_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Late inputs: nothing is certified. Of each of 3 gains and 2 rates, two loops are tried instead of 8."""
    tried, certificate_of = list[tuple[str, float, int]](), choose.certificate_of

    def counted(choices: Choices, trial: LoopTrial) -> ScenarioCertificate:
        tried.append((trial.gain.method, trial.rate_hz, trial.mansd))
        return certificate_of(choices, trial)

    monkeypatch.setattr(choose, "certificate_of", counted)
    delay = {"kind": "delay", "delay_s": 5.0}
    settings = {"network.impairments": [delay], "horizon_s": 5.0}
    made = noack.new("unstable_pendulum", allowed={}, settings=settings)
    assert made.certificate is None
    assert len(set(tried)) == 3 * 2 * 2


@pytest.mark.usefixtures("short_searches")
def test_a_plant_whose_current_is_too_fast_for_its_rate_has_no_guarantee() -> None:
    """e^(−As) of the motor's current, of 1.5e6 /s, and an input of 1 ms is beyond all floats."""
    made = noack.new("dc_motor")
    assert made.guarantee.startswith("no guarantee: ")
    assert "numbers larger than 1e308" in made.guarantee


@pytest.mark.deep
@pytest.mark.usefixtures("short_searches")
def test_a_run_lasts_until_its_guarantee_has_begun() -> None:
    made = noack.new(noack.gain("unstable_pendulum"), "made.toml", allowed={"angle": 0.003})
    begins = re.search(r"from ([\d.]+) s on", made.guarantee)
    assert begins is not None
    assert float(begins[1]) < made.scenario.horizon_s
    assert noack.new(noack.gain("double_integrator"), settings={"horizon_s": 0.5}).scenario.horizon_s == 0.5


SERVO = """
class Servo:
    states = ["angle, rad", "rate, rad/s"]
    inputs = ["voltage, V"]
    allowed = {"angle": 0.02}
    initial_state = [1.0, 0.0]

    def derivative(self, t_s, z, u):
        return z[1], -4.0 * z[1] + 20.0 * u[0]
"""


def test_states_are_named_by_a_class_that_does_not_name_its_inputs() -> None:
    Path("servo.py").write_text(SERVO.replace('    inputs = ["voltage, V"]\n', ""))
    model = noack.linearise("servo.py")
    assert model.plant.names == (("angle", "rate"), None)
    assert (model.plant.m, model.plant.units) == (1, ("rad", "rad/s"))


@pytest.mark.usefixtures("short_searches")
def test_one_command_leads_from_a_class_to_a_guarantee_in_its_own_units() -> None:
    Path("servo.py").write_text(SERVO)
    first, *_ = command("new", "servo.py").stdout.splitlines()
    promised = re.fullmatch(
        r"angle stays within 0.02 rad of its set-point from ([\d.]+) s on, although up to 4 consecutive "
        r"packets are lost \(.*\)",
        first,
    )
    assert promised is not None
    scenario = noack.load("servo")  # of the current folder
    assert scenario.loop_outputs() == (LoopOutput("angle", "rad", (1.0, 0.0), 0.02),)
    assert scenario.model.state_units == ("rad", "rad/s")
    assert scenario.plant.initial_state == (1.0, 0.0)
    for seed in range(2):
        run = noack.simulate(noack.load("servo", {"seeds.loss": seed, "certificate.prove": False}))
        rows = run.table("plant_step").to_pydict()
        late = np.array(rows["t_s"]) >= float(promised[1])
        assert np.abs(np.array(rows["angle"])[late]).max() <= 0.02
    smaller = command("new", "servo.py", "--allow", "angle=0.002", "--out", "smaller.toml").stdout
    assert smaller.startswith("angle stays within 0.002 rad")
    assert noack.load("smaller").trigger.floor < scenario.trigger.floor / 5


def test_a_guarantee_is_kept_if_nothing_is_proven_with_a_larger_threshold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Path("servo.py").write_text(SERVO)
    prove, tried = choose.TrialProofs.of, list[LoopTrial]()

    def only_the_first(proofs: choose.TrialProofs, trial: LoopTrial) -> Certificates:
        tried.append(trial)
        return prove(proofs, trial) if len(tried) == 1 else Certificates(scenario_of(proofs.choices, trial))

    monkeypatch.setattr(choose.TrialProofs, "of", only_the_first)
    made = noack.new("servo.py", "servo.toml")
    assert len(tried) == 2
    first_proof = "angle stays within 0.144 rad of its set-point in the end, not within 0.02 rad"
    assert made.guarantee.startswith(f"no guarantee of the allowed error: {first_proof}")
    assert made.scenario.trigger.floor != tried[1].floor


def test_the_written_settings_are_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Proofs change the threshold after the first simulation; what is said is about the last one."""
    Path("servo.py").write_text(SERVO)
    simulated = list[noack.Scenario]()

    def noted(choices: Choices, trial: LoopTrial) -> bool:
        simulated.append(scenario_of(choices, trial))
        choose.returns_to_rest(choices, trial)
        return len(simulated) == 1

    monkeypatch.setattr(new_scenario, "returns_to_rest", noted)
    made = noack.new("servo.py", "servo.toml")
    assert simulated[-1] == made.scenario != simulated[0]
    assert any("the loop does not return to 0" in note for note in made.notes)


CLIPPED = """
import numpy as np

class Drive:
    states = ["speed, rad/s", "current, A"]
    inputs = ["voltage, V"]
    allowed = {"speed": 5.0}
    initial_state = [50.0, 0.0]

    def derivative(self, t_s, z, u):
        w, i = z
        v = np.clip(u[0], -24.0, 24.0)
        return (0.05 * i - 1e-4 * w) / 2e-4, (v - 0.5 * i - 0.05 * w) / 1e-3
"""


@pytest.mark.deep
def test_a_bound_that_says_only_that_the_loop_stays_bounded_is_called_so() -> None:
    Path("drive.py").write_text(CLIPPED)
    made = noack.new("drive.py", "drive.toml")
    assert made.guarantee.startswith("no guarantee of the allowed error: speed stays within ")
    assert "in the end, not within 5 rad/s" in made.guarantee
    assert made.notes[0].endswith("50 rad/s: it says only that speed stays bounded.")


@pytest.mark.deep
def test_another_rule_is_given_as_a_whole_table() -> None:
    made = noack.new("unstable_pendulum", settings={"trigger": {"policy": "periodic", "period_s": 0.01}})
    assert made.scenario.trigger.policy == "periodic"


@pytest.mark.deep
@pytest.mark.usefixtures("short_searches")
def test_dry_friction_is_left_out_of_the_model_and_kept_in_the_guarantee() -> None:
    """Its tanh is steep for the speeds of the loop; the class of the readme uses math."""
    (code,) = blocks("README.md", "python")
    Path("servo.py").write_text(code)
    made = noack.new("servo.py", "servo.toml")
    assert made.gain.model.A[1, 1] == pytest.approx(-4.0, rel=1e-3)  # of the viscous friction
    promised = re.fullmatch(
        r"angle stays within 0.02 rad of its set-point from ([\d.]+) s on, although up to 4 consecutive "
        r"packets are lost \(proved\)",
        made.guarantee,
    )
    assert promised is not None, made.guarantee
    made.save("servo.toml")
    for seed in range(2):
        run = noack.simulate(noack.load("servo", {"seeds.loss": seed, "certificate.prove": False}))
        rows = run.table("plant_step").to_pydict()
        assert rows["angle"] == rows["x_1"]
        late = np.array(rows["t_s"]) >= float(promised[1])
        assert np.abs(np.array(rows["angle"])[late]).max() <= 0.02


@pytest.mark.usefixtures("short_searches")
@pytest.mark.parametrize(("effect", "unit"), [(2.5, 1.0), pytest.param(0.02, 1000.0, marks=pytest.mark.deep)])
def test_units_of_inputs_and_states_do_not_matter(effect: float, unit: float) -> None:
    """A torque in N m, or degrees and a current in mA, instead of a voltage with effect 20 and radians."""
    (code,) = blocks("README.md", "python")
    code = code.replace("20.0 * u[0]", f"{effect} * {unit} * u[0]").replace(
        "0.5 * math", f"{0.5 * unit} * math"
    )
    code = code.replace("rate / 0.05", f"rate / {0.05 * unit}").replace("1.0, 0.0]", f"{unit}, 0.0]")
    Path("servo.py").write_text(code.replace("0.02}", f"{0.02 * unit}}}"))
    made = noack.new("servo.py", "servo.toml")
    assert made.gain.model.A[1, 1] == pytest.approx(-4.0, rel=1e-3)
    assert made.gain.decay_per_s == pytest.approx(9.75, rel=0.01)
    start = re.escape(f"angle stays within {0.02 * unit:g} rad of its set-point from ")
    assert re.fullmatch(rf"{start}3\.\d+ s on, although up to 4 .* \(proved\)", made.guarantee)


@pytest.mark.usefixtures("short_searches")
def test_an_input_that_is_used_little_is_said_to_be_so() -> None:
    hint = "noack gain pole.py:Heavy --r R --out gain.json, R below 1; noack new gain.json."
    assert noack.new("pole.py:Heavy", "heavy.toml").notes[-1].endswith(hint)
    faster = noack.gain("pole.py:Heavy", r=1e-4)
    assert faster.decay_per_s > 0.1
    assert not noack.new(faster, "faster.toml").notes[-1].endswith(hint)


def test_friction_that_jumps_is_refused_with_what_to_write_instead() -> None:
    (code,) = blocks("README.md", "python")
    code = code.replace("import math", "import numpy as np").replace(
        "math.tanh(rate / 0.05)", "np.sign(rate)"
    )
    Path("servo.py").write_text(code)
    with pytest.raises(CallerError, match=r"servo.py: .* cannot be integrated at .* write np.tanh\(v / w\)"):
        noack.new("servo.py", "servo.toml")


@pytest.mark.parametrize("name", ["cart_pole", "four_tank", "quadrotor"])
def test_the_regulator_solves_the_riccati_equation(name: str) -> None:
    model = noack.linearise(name)
    n, m = model.B.shape
    regulator = noack.gain(model, q=np.arange(1.0, n + 1), r=0.5)
    Q, R = np.diag(np.arange(1.0, n + 1)), 0.5 * np.eye(m)
    P = solve_continuous_are(model.A, model.B, Q, R)
    residual = model.A.T @ P + P @ model.A + Q - regulator.K.T @ R @ regulator.K
    assert np.abs(residual).max() < 1e-6 * np.abs(P).max()
    assert regulator.decay_per_s > 0


def test_one_input_places_a_repeated_pole() -> None:
    assert noack.gain("double_integrator", poles=[-2, -2]).K.tolist() == [[-4.0, -4.0]]  # (s + 2)²


@pytest.mark.parametrize("poles", [[-1, -2, -3, -4], [-2 + 1j, -2 - 1j, -3 + 2j, -3 - 2j]])
def test_a_regulator_has_the_poles_that_were_asked_for(poles: list[complex]) -> None:
    placed = noack.gain("cart_pole", poles=poles)
    np.testing.assert_allclose(np.sort_complex(placed.eigenvalues), np.sort_complex(poles), atol=1e-5)


def test_a_plant_that_makes_its_own_steps_is_linearised() -> None:
    model = noack.linearise("pole.py:Stepped")
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], [-2.0, 1.0], atol=1e-6)


def test_uncontrollable_states_are_found_in_any_coordinates() -> None:
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4)))[0]
    A = rotation @ np.diag([1.0, -2.0, -2.0, -5.0]) @ rotation.T
    B = rotation @ np.array([[1.0], [1.0], [0.0], [0.0]])
    assert controllable_states(A, B).shape == (4, 2)
    assert controllable_states(np.diag([1.0, 1.0]), np.ones((2, 1))).shape == (2, 1)
    # Two masses that no input moves, beside two that rounding couples: the same in any order.
    arms = np.zeros((8, 8))
    arms[:4, 4:] = np.eye(4)
    arms[:2, 4:6] += [[0, 1.4e-13], [1.4e-13, 0]]
    arms[4:6, 4:6] = [[-0.998848, 4.02603e-4], [4.02603e-4, -0.999821]]
    moved = np.zeros((8, 2))
    moved[:2] = [[1.67e-8, -2.7e-11], [-2.7e-11, 1.68e-8]]
    moved[4:6] = [[199.77, -0.0805], [-0.0805, 199.964]]
    assert controllable_states(arms, moved).shape == (8, 4)
    stiff = noack.linearise("dc_motor")  # 1e6 between its eigenvalues
    assert np.array_equal(noack.linearise("dc_motor", input=0.0).A, stiff.A)  # a number is enough
    assert stiff.rank == 3
    chain = np.diag(np.ones(5), 1)
    assert controllable_states(chain, np.eye(6)[:, -1:]).shape == (6, 6)


def test_a_plant_that_cannot_be_stabilised_gives_one_line() -> None:
    model = noack.linearise("pole.py:Unreachable")
    assert (model.rank, model.uncontrollable.tolist()) == (1, [1.0])
    assert "no gain stabilises the plant" in repr(model)
    with pytest.raises(CallerError, match="the eigenvalue 1 /s is not controllable"):
        noack.new(model)


@pytest.mark.parametrize(
    ("states", "allowed", "force", "line"),
    [
        ('["angle", "angle"]', "{}", "u[0]", "states: angle occurs more than once"),
        ('["angle, rad", "angle, m"]', "{}", "u[0]", "states: angle occurs more than once"),
        ('["angle", "rate"]', '["angle"]', "u[0]", "allowed is ['angle']; give errors by states"),
        (
            '["angle", "rate"]',
            "{}",
            "u[0] + )",
            "mistaken.py: SyntaxError: unmatched ')' (mistaken.py, line 7)",
        ),
        # Of a loop that decays as e^(-2.5e-10t), simulations would not end.
        (
            '["angle", "rate"]',
            "{}",
            "1e-9 * u[0]",
            "without errors x decays as e^(−2.5e-10t) only, too slowly",
        ),
    ],
)
def test_a_mistake_in_a_class_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, states: str, allowed: str, force: str, line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mistaken.py").write_text(
        f"class Arm:\n    states = {states}\n    inputs = ['torque']\n    allowed = {allowed}\n\n"
        f"    def derivative(self, t_s, z, u):\n        return z[1], {force} - 4.0 * z[1]\n"
    )
    result = invoke("new", "mistaken.py")
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert line in result.stderr


def test_the_lines_about_mistakes_are_those_that_were_approved() -> None:

    def mistake(line: str) -> list[str]:
        result = invoke(*line.split())
        assert result.exit_code in (1, 2), result.output
        assert result.stderr.count("\n") == 1
        assert result.stdout == ""
        return [result.stderr.strip()]

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)
