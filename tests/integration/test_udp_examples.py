"""The examples of UDP programs that are tested under losses run as a user would run them."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.helpers.live_runs import PATIENCE_S
from tests.integration.wheels import ENVIRONMENT, ROOT, Installed, built, install, wheel_of_sdist

pytestmark = [pytest.mark.system]
EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The emulator and pytest, as `pip install noack-netem pytest` installs them, and the example."""
    place = tmp_path_factory.mktemp("user")
    wheels = [
        wheel_of_sdist(ROOT / "netem", tmp_path_factory.mktemp("netem"), "netem", "core"),
        built(EXAMPLES / "udp_ci", tmp_path_factory.mktemp("thermo"), "wheel"),
    ]
    return install(place, "noack-netem", wheels, also=("pytest", "pluggy", "iniconfig", "packaging"))


def run(environment: Installed, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    path = f"{environment.program.parent}{os.pathsep}{ENVIRONMENT['PATH']}"
    return subprocess.run(
        words, cwd=folder, env=ENVIRONMENT | {"PATH": path}, capture_output=True, text=True,
        check=False, timeout=PATIENCE_S,
    )  # fmt: skip


def test_each_step_of_the_workflow_passes(environment: Installed, tmp_path: Path) -> None:
    folder = shutil.copytree(EXAMPLES / "udp_ci", tmp_path / "udp_ci")
    workflow = (folder / ".github" / "workflows" / "test.yml").read_text()
    commands = re.findall(r"^ +(?:- )?run: (.+)$", workflow, re.MULTILINE)
    assert commands == ["pip install noack-netem pytest .", "pytest", "./through_losses.sh"]
    tests = run(environment, folder, str(environment.python), "-m", "pytest", "-p", "no:cacheprovider")
    assert tests.returncode == 0, tests.stdout
    assert "3 passed" in tests.stdout
    beside = run(environment, folder, commands[-1])
    assert (beside.returncode, beside.stdout) == (0, "61.5\n20.25\n-3.0\n"), beside.stderr
    assert (folder / "statistics.jsonl").read_text().count("\n") >= 1


def test_the_page_shows_the_workflow_and_the_script() -> None:
    page = (ROOT / "docs" / "netem-ci.md").read_text()
    assert (EXAMPLES / "udp_ci" / ".github" / "workflows" / "test.yml").read_text() in page
    script = (EXAMPLES / "udp_ci" / "through_losses.sh").read_text()
    assert script[script.index("python -m thermo.server") :] in page


def test_the_program_in_c_passes(environment: Installed, tmp_path: Path) -> None:
    if shutil.which("cc") is None or shutil.which("make") is None:
        pytest.skip("there is no C compiler, or no make")
    folder = shutil.copytree(EXAMPLES / "udp_ci_c", tmp_path / "udp_ci_c")
    done = run(environment, folder, "make", "--silent", "test")
    assert done.returncode == 0, done.stderr
    assert '"longest_loss_burst": 2' in done.stdout


def test_the_image_of_the_emulator_is_small(environment: Installed, tmp_path: Path) -> None:
    builder = next((name for name in ("podman", "buildah", "docker") if shutil.which(name)), None)
    if builder is None or subprocess.run([builder, "info"], capture_output=True, check=False).returncode:
        pytest.skip("no builder of containers works here")
    wheel = wheel_of_sdist(ROOT / "netem", tmp_path, "netem", "core")
    shutil.copyfile(ROOT / "netem" / "Containerfile", wheel.parent / "Containerfile")
    made = subprocess.run(
        [builder, "build", "--tag", "noack-netem-test", wheel.parent],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode and "pull" in made.stderr.lower():
        pytest.skip("the base image cannot be fetched here")
    assert made.returncode == 0, made.stderr
    saved = tmp_path / "image.tar"
    subprocess.run([builder, "save", "--output", saved, "noack-netem-test"], check=True)
    subprocess.run(["gzip", saved], check=True)
    assert saved.with_suffix(".tar.gz").stat().st_size <= 120e6
    explained = subprocess.run(
        [builder, "run", "--rm", "noack-netem-test", "--explain", "loss", "5%"],
        capture_output=True,
        check=False,
    )
    assert explained.returncode == 0
