"""A shell: all packets of a command pass the rules, and nothing of it is left afterwards."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, NoReturn

import pytest

from netem.__main__ import main
from netem.core.command_line import Signals
from netem.impairments.link_settings import LinkSettings
from netem.relay.relay_links import DeviceLink, LinkSpec
from netem.shell import process, shell

pytestmark = [pytest.mark.live, pytest.mark.system]

ENDS = str(Path(__file__).with_name("shell_ends.py"))
SHELL = [sys.executable, "-m", "netem", "shell"]
PATIENCE_S = 120


def run(*words: str, **how: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*SHELL, *words], capture_output=True, text=True, timeout=PATIENCE_S, **how)


@cache
def why_not() -> str:
    """Return why this system has no shells; empty: it has them."""
    tried = run("--", "true") if shutil.which("ip") else None
    return "there is no ip" if tried is None else tried.stderr if tried.returncode else ""


@pytest.fixture(autouse=True)
def _permitted(request: pytest.FixtureRequest) -> None:
    if why_not():
        pytest.skip(why_not())


def need(*programs: str) -> None:
    if missing := [program for program in programs if shutil.which(program) is None]:
        pytest.skip(f"there is no {', '.join(missing)}")


def free_port() -> int:
    with socket.socket(socket.AF_INET6) as endpoint:
        endpoint.bind(("::", 0))
        return int(endpoint.getsockname()[1])


def longest_burst(lost: set[int]) -> int:
    bursts = groupby(enumerate(sorted(lost)), lambda pair: pair[1] - pair[0])
    return max((len(list(group)) for _, group in bursts), default=0)


class Totals:
    """Results of a shell: what its ends received, and its statistics."""

    def __init__(self, folder: Path, *words: str, change: tuple[str, ...] = ()) -> None:
        count = "40" if change else "200"
        server = ["--outside", f"{sys.executable} {ENDS} server {folder}"]
        ends = [sys.executable, ENDS, "client", str(folder), count, *change]
        statistics = ["--stats-file", str(folder / "stats.json")]
        done = run(*words, *statistics, *server, "--", *ends, cwd=Path(__file__).parents[3])
        assert done.returncode == 0, done.stderr
        assert "lost in the kernel" not in done.stderr
        self.count = int(count)
        self.flows = json.loads((folder / "ends.json").read_text())
        last = (folder / "stats.json").read_text().splitlines()[-1]
        self.link = json.loads(last)["links"][0]

    def longest_burst(self, flow: str, direction: str) -> int:
        """Return the emulator's count of the longest burst of a flow."""
        text = f":{self.flows[flow]['port']} "
        (counts,) = (row for row in self.link[direction]["flows"] if text in row["client"])
        return int(counts["longest_loss_burst"])


def test_the_ends_miss_the_bursts_that_the_emulator_counts(tmp_path: Path) -> None:
    """In both directions, over both versions of IP."""
    totals = Totals(tmp_path, "--both", "loss", "45%", "mansd", "4", "--seed", "7")
    for flow, ends in totals.flows.items():
        there = ends["there"]
        missing = set(range(totals.count)) - set(there)
        assert longest_burst(missing) == totals.longest_burst(flow, "forward") == 4
        missing = {k for k, number in enumerate(there) if number not in ends["back"]}
        assert longest_burst(missing) == totals.longest_burst(flow, "reverse") == 4
    assert any("udp fragments " in flow["client"] for flow in totals.link["forward"]["flows"])


def test_a_shell_follows_a_timetable(tmp_path: Path) -> None:
    """Nothing passes before 0.5 s; the client asks until it has all its answers."""
    need("ping")
    (tmp_path / "tunnel.csv").write_text(
        "time_s,direction,words\n0,both,loss 100%\n0.5,both,loss none\n1000,,loss 5%\n"
    )
    script = "for k in $(seq 60); do ping -c 1 -W 1 198.18.16.1 > /dev/null && exit 0; done; exit 1"
    files = ["--timetable", str(tmp_path / "tunnel.csv"), "--json"]
    done = run(*files, "--", "sh", "-c", script)
    assert done.returncode == 0, done.stderr
    assert f"{tmp_path}/tunnel.csv: 5 changes of settings, the last at 1000 s" in done.stderr
    forward = json.loads(done.stdout)["links"][0]["forward"]
    assert forward["words"] == "loss none"
    wrong = run("--timetable", str(tmp_path / "tunnel.csv"), "--repeat", "1s", "--", "true")
    assert wrong.returncode == 2
    assert "line 4: time_s is 1000, but the timetable repeats every 1 s" in wrong.stderr


def test_changed_settings_do_not_reset_the_memory_of_a_flow(tmp_path: Path) -> None:
    name = f"shell-{os.getpid()}"
    words = ["loss", "100%", "mansd", "4", "--control", name]
    totals = Totals(tmp_path, *words, change=("2", "loss 100% mansd 4 delay 1ms", name))
    assert totals.flows["ipv4"]["there"] == list(range(4, totals.count, 5))


def test_shells_nest_and_programs_work(tmp_path: Path) -> None:
    need("ping", "curl", "iperf3")
    (tmp_path / "page").write_text("a page")
    page_port, iperf_port = free_port(), free_port()
    outside = [
        "--outside", f"{sys.executable} -m http.server -b :: -d {tmp_path} {page_port}",
        "--outside", f"iperf3 -s -p {iperf_port}",
    ]  # fmt: skip
    script = f"""
        set -e
        far=$NOACK_OUTSIDE far6=$NOACK_OUTSIDE6
        until curl -sf http://$far:{page_port}/page; do sleep 0.1; done
        {" ".join(SHELL)} delay 30ms -- sh -c "
            set -e
            ping -c 3 $far
            [ -z '$far6' ] || ping -6 -c 3 $far6
            curl -sf --retry 9 --retry-connrefused http://$far:{page_port}/page
            curl -sf --retry 9 --retry-connrefused http://[$far6]:{page_port}/page
            until iperf3 -c $far -p {iperf_port} -n 200K; do sleep 0.1; done
            until iperf3 -c $far -p {iperf_port} -u -n 200K; do sleep 0.1; done"
    """
    done = run("--both", "delay", "20ms", *outside, "--", "sh", "-c", script)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("a page") == 3
    trips_ms = [
        float(word.removeprefix("time="))
        for word in done.stdout.split() if word.startswith("time=") and word != "time="
    ]  # fmt: skip
    assert len(trips_ms) >= 3
    assert min(trips_ms) >= 70


@pytest.mark.parametrize(("command", "status"), [("exit 7", 7), ("kill -9 $$", 128 + 9)])
def test_the_status_of_the_command_is_that_of_the_shell(command: str, status: int) -> None:
    assert run("--", "sh", "-c", command).returncode == status


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--", "no-such-program"], "no-such-program: there is no such program"),
        (["loss", "300%", "--", "true"], "loss 300%: expected a percentage from 0% to 100%"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["shell", *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert line in error


@pytest.mark.parametrize("killed", ["relay", "guard", "both", "group", "all", "terminated"])
def test_the_shell_leaves_no_process_behind(killed: str) -> None:
    """All of them have the pipe: its end is the end of the last one."""
    script = "(setsid sleep 1000 &) ; sleep 1000 & echo $PPID; wait"
    with subprocess.Popen(
        [*SHELL, "--outside", "sleep 1000", "--", "sh", "-c", script],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, process_group=0,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        guard = int(process.stdout.readline())
        if killed == "relay":
            process.kill()
        elif killed == "guard":
            os.kill(guard, signal.SIGKILL)
        elif killed == "both":  # neither notices the end of the other
            for number in (signal.SIGSTOP, signal.SIGKILL):
                for pid in (guard, process.pid):
                    os.kill(pid, number)
        elif killed == "all":
            os.killpg(process.pid, signal.SIGKILL)
        elif killed == "group":
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.terminate()
        assert process.stdout.read() == ""
    expected = {"relay": -9, "all": -9, "both": -9, "guard": 128 + 9, "group": 130, "terminated": 143}
    assert process.returncode == expected[killed]


def test_the_commands_outside_end_if_the_one_inside_cannot_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_devices: DeviceLink) -> NoReturn:
        raise OSError("no namespace")

    monkeypatch.setattr(shell, "inside", refuse)
    monkeypatch.setattr(process, "adopt_orphans", lambda: None)  # pytest stays no reaper
    spec = LinkSpec("shell", ("198.18.0.2", 0), ("198.18.0.1", 0), LinkSettings(), LinkSettings())
    devices = DeviceLink(spec, (-1, -1), (-1, -1), -1, None)
    earlier_children = process.children(os.getpid())
    program = shell._Program(devices, ["true"], [["sleep", "1000"]])
    with pytest.raises(OSError, match="no namespace"), program.running(Signals()):
        pass
    assert process.children(os.getpid()) <= earlier_children


def test_a_shell_on_a_host_with_many_devices_counts_its_own_drops() -> None:
    """One call returns some kilobytes of /proc/net/dev: the lines of about 30 devices."""
    need("unshare")
    if os.getuid() != 0:
        pytest.skip("makes network devices on the host: takes root")
    names = " ".join(f"xd{number}" for number in range(1, 60))
    make = f"for name in {names}; do ip tuntap add name $name mode tun; done"
    command = f"{make}; {sys.executable} -m netem shell -- true"
    done = subprocess.run(
        ["unshare", "--net", "sh", "-c", command], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
