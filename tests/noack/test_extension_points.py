"""Parts of installed packages, right and wrong ones, in programs of their own."""

from pathlib import Path

import pytest

from netem.core.extension_points import NO_EXTENSIONS
from tests.helpers.command_line import invoke
from tests.helpers.installed_packages import install, run

PLANT = """
from typing import Literal
from noack.plants.plant_settings import EquationSettings, PlantEquations

class SwingSettings(EquationSettings):
    "A pendulum of which only small angles are considered."
    kind: Literal["KIND"]
    length_m: float = 1.0

    def equations(self):
        return PlantEquations(lambda t, z, v: (z[1], -9.81 / self.length_m * z[0] + v[0]))
"""
GUST = """
from typing import ClassVar, Literal
import numpy as np
from noack.extend import DisturbanceSettings, Row

class GustSettings(DisturbanceSettings):
    "A constant wind; nothing but its signal says how strong it is."
    entries_key: ClassVar = "amplitude"
    kind: Literal["gust"]
    amplitude: Row

    def signal(self, steps, source):
        return np.tile(self.amplitude, (len(steps), 1))
"""
POLICY = """
from typing import Literal
from noack.trigger_policies.absolute import AbsoluteSettings

class ImpatientSettings(AbsoluteSettings):
    "A threshold."
    policy: Literal["impatient"]
    patience_s: float = 1.0
"""
EXPORT = 'SUFFIX = ".txt"\n\ndef write(run, path, *, certificates=True):\n    return [path]\n'
KINDS = "from noack.scenario.sections import PLANTS; print(*[kind for kind in PLANTS if 's' in kind])"


def test_a_plant_and_an_export_of_a_package_are_parts_of_noack(tmp_path: Path) -> None:
    groups = "[noack.plants]\nswing = swing_plant\n[noack.exports]\nname = swing_export\n"
    install(tmp_path, "noack-swing", groups, swing_plant=PLANT.replace("KIND", "swing"), swing_export=EXPORT)
    system = '--set=plant.system={kind="swing",length_m=2.0}'
    others = ("--set=plant.draw=nominal", "--set=plant.uncertainty_B=[[0],[0]]")
    _, warnings = run(tmp_path, "-m", "cosim.cli", "check", "double_integrator", system, *others)
    assert warnings == []
    schema, _ = run(tmp_path, "-m", "cosim.cli", "schema")
    assert "SwingSettings" in schema
    schema, _ = run(tmp_path, "-m", "cosim.cli", "schema", **{NO_EXTENSIONS: "1"})
    assert "SwingSettings" not in schema
    formats = "from cosim.output.export.export_formats import formats; print('swing' in formats())"
    assert run(tmp_path, "-c", formats) == ("True", [])


def test_certificates_cover_no_disturbance_and_no_policy_of_a_package(tmp_path: Path) -> None:
    groups = "[noack.disturbances]\ngust = gust\n[noack.triggers]\nimpatient = impatient\n"
    install(tmp_path, "noack-gust", groups, gust=GUST, impatient=POLICY)
    gust = 'plant.disturbances=[{kind="gust", amplitude=[1.0]}]'
    policy = 'trigger={policy="impatient", delta=0.1}'
    program = (
        "import sys; from noack.proof.elaborate.keys import refusals; "
        "from tests.helpers.shipped import resolved; "
        "print(*refusals(dict(resolved('double_integrator', *sys.argv[1:]).content())), sep='\\n')"
    )
    output, warnings = run(tmp_path, "-c", program, gust, policy)
    assert warnings == []
    assert output.splitlines() == [
        'plant.disturbances.kind = "gust": this disturbance has no bound',
        'trigger.policy = "impatient": this policy is not covered',
        "trigger.patience_s: no statement covers this key",
    ]


BROKEN = {
    "end": ("swing_end", "class End(BaseException): ...\nraise End('at once')", "End: at once"),
    "syntax": ("swing_x", "x = (", "SyntaxError: '(' was never closed (swing_x.py, line 1)"),
    "nothing": ("swing_nothing", "", "it has nothing for the group noack.plants"),
    "taken": ("swing_taken", PLANT.replace("KIND", "linear"), "ValueError: kind = linear exists already"),
    "unnamed": ("not a module !", None, ""),
}
"""By package: its module, the text of this, and why it is ignored."""


def test_each_broken_package_costs_one_line(tmp_path: Path) -> None:
    for package, (module, text, _) in BROKEN.items():
        points = f"[noack.plants]\nswing = {module}\n[noack.triggers]\nswing = not_there\n"
        modules = {} if text is None else {module: text}
        install(tmp_path, f"noack-{package}", points, **modules)
    again = "import subprocess, sys; subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)"
    output, warnings = run(tmp_path, "-c", f"{KINDS}; {again}", KINDS)
    assert "swing" not in output
    # The program that it starts prints no others.
    for line, (package, (module, _, reason)) in zip(sorted(warnings), sorted(BROKEN.items()), strict=True):
        start = f"noack: warning: a part of the extension noack-{package} is ignored: {module}: {reason}"
        assert line.startswith(start)


@pytest.mark.parametrize(("words", "package"), [
    (["check", "double_integrator", "--set", "plant.system.kind=fmu"], "noack-fmi"),
    (["check", "cart_pole_mujoco"], "noack-gymnasium"),
    (["linearise", "gymnasium:Pendulum-v1"], "noack-gymnasium"),
    (["bridge", "lane_following"], "noack-ros2"),
])  # fmt: skip
def test_what_an_extension_of_noack_has_is_answered_with_its_package(words: list[str], package: str) -> None:
    result = invoke(*words)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1), result.output
    assert f"needs an extension that is not installed; pip install {package}" in result.stderr
