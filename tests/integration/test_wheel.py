"""The built and installed packages work without the repository."""

import json
import shutil
import signal
import subprocess
import zipfile
from pathlib import Path

import pytest

from tests.helpers.live_runs import EPHEMERAL, PATIENCE_S
from tests.integration.wheels import (
    ENVIRONMENT,
    ROOT,
    Installed,
    built,
    content,
    files_below,
    install,
    wheel_of_sdist,
)

pytestmark = [pytest.mark.system]
PACKAGES = (
    "noack", "plant_server", "sensor_node", "controller_node", "cosim", "noack_kernel", "noack_gains",
    "noack_equations", "noack_verify",
)  # fmt: skip
TEST = """
import socket

def test_of_a_server(lossy_udp):
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))
    server.settimeout(60)
    link = lossy_udp(server.getsockname(), "loss 30% mansd 2")
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for _ in range(3):  # at most two are lost
        client.sendto(b"x", link.address)
    assert server.recv(10) == b"x"
    client.close()
    server.close()
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """noack's wheel, from its source distribution."""
    return wheel_of_sdist(ROOT, tmp_path_factory.mktemp("noack"), "noack", "noack/core")


@pytest.fixture(scope="module")
def netem_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the emulator alone."""
    return wheel_of_sdist(ROOT / "netem", tmp_path_factory.mktemp("netem"), "netem", "core")


@pytest.fixture(scope="module")
def noack(wheel: Path, netem_wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """Both wheels, in an environment that has the packages that they need and no others."""
    return install(tmp_path_factory.mktemp("clean"), "noack", [wheel, netem_wheel])


@pytest.fixture(scope="module")
def netem(netem_wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The emulator alone, with pytest."""
    return install(
        tmp_path_factory.mktemp("netem"),
        "noack-netem",
        [netem_wheel],
        also=("pytest", "pluggy", "iniconfig", "packaging"),
    )


@pytest.fixture(scope="module")
def measuring(netem_wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The emulator with what predicts and measures."""
    return install(tmp_path_factory.mktemp("measure"), "noack-netem", [netem_wheel], "measure")


def test_the_sdists_make_the_same_wheels_as_the_repository(
    wheel: Path, netem_wheel: Path, tmp_path: Path
) -> None:
    assert content(wheel) == content(built(ROOT, tmp_path / "noack", "wheel"))
    assert content(netem_wheel) == content(built(ROOT / "netem", tmp_path / "netem", "wheel"))


def test_the_wheels_contain_the_packages_and_their_data_only(wheel: Path, netem_wheel: Path) -> None:
    names = set(content(wheel))
    for folder in ("scenarios", "campaigns"):
        paths = (ROOT / folder).rglob("*")
        kept = {path for path in paths if path.suffix in (".toml", ".csv", ".md")}
        assert {f"cosim/{path.relative_to(ROOT)}" for path in kept} <= names
    for package in PACKAGES:
        root = ROOT / "checker" if (ROOT / "checker" / package).exists() else ROOT
        assert files_below(root / package) <= names
    of_netem = set(content(netem_wheel))
    of_build = {
        "netem/README.md",
        "netem/pyproject.toml",
        "netem/hatch_build.py",
        "netem/LICENSE",
        "netem/Containerfile",
    }
    assert files_below(ROOT / "netem") - of_build == {name for name in of_netem if ".dist-info" not in name}
    for found, packages in ((names, PACKAGES), (of_netem, ("netem",))):
        (about,) = {name.partition("/")[0] for name in found} - set(packages)
        assert about.endswith(".dist-info")
        assert not [name for name in found if "__pycache__" in name]


def test_only_the_emulators_wheel_has_the_plugin_of_pytest(wheel: Path, netem_wheel: Path) -> None:
    def entry_points(of: Path) -> str:
        (name,) = (name for name in content(of) if name.endswith("entry_points.txt"))
        with zipfile.ZipFile(of) as file:
            return file.read(name).decode()

    assert "pytest11" not in entry_points(wheel)
    assert "netem.pytest_plugin" in entry_points(netem_wheel)


def test_the_installed_wheel_runs_without_the_repository(noack: Installed) -> None:
    assert noack("--version").stdout.startswith("noack ")
    run = noack.json("demo", *EPHEMERAL, "--set", "horizon_s=0.5", "--report")
    assert run["exit"]["status"] == 0
    assert run["loops"][0]["replay"]["bit_exact"]
    report = (noack.folder / "runs" / "latest" / "report.html").read_text(encoding="utf-8")
    assert report.count("<figure") == 9
    assert "completed 0.5 s" in report
    view = noack("view")
    assert (view.returncode, view.stderr.count("\n")) == (2, 1)
    assert "pip install 'noack[viewer]'" in view.stderr
    assert noack("netem", "--explain", "loss", "5%").returncode == 0
    doctor = json.loads(noack("doctor", *EPHEMERAL, "--seconds", "0.1", "--json").stdout)
    assert doctor["measured"]["viewer"] is None


def test_the_emulator_alone_relays(netem: Installed) -> None:
    words = ("--listen", "127.0.0.1:0", "--to", "127.0.0.1:9", "--json", "loss", "30%", "mansd", "4")
    with subprocess.Popen(
        [netem.program, *words], cwd=netem.folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    ) as relay:
        assert relay.stdout is not None
        try:
            assert json.loads(relay.stdout.readline())["ready"][0]["to"] == "127.0.0.1:9"
        finally:
            relay.send_signal(signal.SIGINT)
        totals = json.loads(relay.communicate(timeout=PATIENCE_S)[0])
    assert totals["links"][0]["forward"]["loss"]["predicted"] == pytest.approx(0.298, abs=1e-3)
    assert relay.returncode == 0


def test_the_emulator_alone_is_a_fixture_of_pytest(netem: Installed) -> None:
    (netem.folder / "test_server.py").write_text(TEST)
    done = netem.run(netem.python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_server.py")
    assert (done.returncode, "1 passed" in done.stdout) == (0, True), done.stdout


def test_the_emulator_alone_is_a_shell(netem: Installed) -> None:
    """A datagram of the command passes the relay; `loss 100% mansd 0` loses none."""
    isolated = ["unshare", "--user", "--map-root-user", "--net", "true"]
    if not (shutil.which("ip") and shutil.which("unshare") and Path("/dev/net/tun").exists()):
        pytest.skip("a shell needs ip, unshare and /dev/net/tun")
    if subprocess.run(isolated, check=False).returncode:
        pytest.skip("there are no namespaces of users here")
    send = "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'x', ('198.18.16.1', 9))"
    done = netem("shell", "--json", "loss", "100%", "mansd", "0", "--", netem.python, "-c", send)
    assert done.returncode == 0, done.stderr
    forward = json.loads(done.stdout)["links"][0]["forward"]
    assert forward["forwarded"] == forward["received"] >= 1


def test_the_emulator_alone_says_what_predictions_need(netem: Installed) -> None:
    explained = netem("--explain", "loss", "gemodel", "1%", "10%", "mansd", "4")
    assert (explained.returncode, explained.stderr) == (0, "")
    assert "expected loss rate: 7.634%" in explained.stdout
    kept = netem("--listen", "127.0.0.1:0", "--to", "127.0.0.1:9", "loss", "5%", "keep", "mansd", "4")
    assert (kept.returncode, kept.stderr.count("\n")) == (2, 1)
    assert "predictions need scipy: pip install 'noack-netem[measure]'" in kept.stderr


def test_the_emulator_alone_says_what_measuring_needs(netem: Installed) -> None:
    done = netem("measure", "urban_n78_40kmh")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "measure needs scipy: pip install 'noack-netem[measure]'" in done.stderr


def test_the_emulator_with_measure_measures(measuring: Installed) -> None:
    words = ("measure", "urban_n78_40kmh", "--deadline", "100ms", "--survival", "120ms")
    document = measuring.json(*words)
    assert document["effective_losses"] == 7
    shown = measuring(*words)
    assert shown.returncode == 0, shown.stderr
    assert "urban_n78_40kmh: at most 4 lost in a row" in shown.stdout


def test_the_emulator_with_measure_predicts(measuring: Installed) -> None:
    explained = measuring.json("--explain", "loss", "5%", "keep", "mansd", "4")
    assert "pip install" not in json.dumps(explained)
