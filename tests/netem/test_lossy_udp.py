"""The emulator within a program, and the plug-in of pytest."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import netem
from netem import pytest_plugin
from netem.core.errors import NoackError
from netem.link_state import LinkState
from netem.links_file import load_links
from netem.tc_words import settings_of
from tests.helpers.pages import blocks
from tests.helpers.waiting import wait_for

PATIENCE_S = 120.0


class Ends:
    """A server that sends datagrams back, and a client; with numbers as datagrams."""

    def __init__(self) -> None:
        self.server = socket.socket(type=socket.SOCK_DGRAM)
        self.server.bind(("127.0.0.1", 0))
        self.client = socket.socket(type=socket.SOCK_DGRAM)
        self.client.bind(("127.0.0.1", 0))
        for end in (self.server, self.client):
            end.settimeout(PATIENCE_S)

    def send(self, link: netem.LossyUdp, numbers: range) -> None:
        for number in numbers:
            self.client.sendto(number.to_bytes(4), link.address)

    def received(self, count: int) -> list[int]:
        return [int.from_bytes(self.server.recv(4)) for _ in range(count)]


@pytest.fixture
def ends() -> Iterator[Ends]:
    both = Ends()
    yield both
    both.server.close()
    both.client.close()


def intact(counts: dict[str, int]) -> int:
    return counts.get("delivered", 0) + counts.get("forced", 0)


def arrived(ends: Ends, words: str, seed: int, count: int = 300) -> list[bool]:
    """Return which of the datagrams arrive, by the receiver."""
    with netem.LossyUdp(ends.server.getsockname(), words, seed=seed) as link:
        ends.send(link, range(count))
        wait_for(lambda: link.forward["received"] == count)
        received = ends.received(intact(link.forward["fates"]))
    assert link.forward["received"] == count  # also after the end
    lost = [len(list(run)) for kept, run in groupby(range(count), received.__contains__) if not kept]
    assert max(lost) == link.forward["longest_loss_burst"]
    return [number in received for number in range(count)]


def test_the_losses_are_those_of_the_seed_and_of_the_rules(ends: Ends) -> None:
    words = "loss 60% mansd 3"
    first = arrived(ends, words, 7)
    assert arrived(ends, words, 7) == first
    assert arrived(ends, words, 8) != first
    link = LinkState(settings_of(words), 7, "relay", "forward")
    link.start_flow(0, 0)
    assert first == [link.decide(0, 4, 0).release_ns >= 0 for _ in first]


def test_a_change_does_not_reset_the_guarantee(ends: Ends) -> None:
    with netem.LossyUdp(ends.server.getsockname(), "loss 100% mansd 3") as link:
        count = 0
        for _ in range(20):  # each change would allow three more losses if it forgot the others
            ends.send(link, range(count, count := count + 2))
            wait_for(lambda count=count: link.forward["received"] == count)
            link.change("loss 100% mansd 3")
        assert ends.received(10) == list(range(3, 40, 4))


@pytest.mark.parametrize(("arguments", "message"), [
    (("127.0.0.1:9", "los 3%"), "los"),
    (("127.0.0.1:9", "loss 3% seed 4"), "seed 4"),
    (("127.0.0.1:9", 5), "words: 5; give words such as"),
    (("127.0.0.1:9", "loss trace none.txt"), "none.txt"),
    (("127.0.0.1:9", "loss 90% keep mansd 1"), "90"),
    (("127.0.0.1:0",), "to: expected a port from 1 to 65535"),
    (((1, 2),), "to: (1, 2); give host and port, or 'host:port'"),
])  # fmt: skip
def test_a_mistake_is_one_line(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(NoackError) as error:
        netem.LossyUdp(*arguments)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def run_pytest(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    plugin = ["-p", "no:noack", "-p", "netem.pytest_plugin"]  # if it is not installed here, too
    return subprocess.run(
        [sys.executable, "-m", "pytest", *plugin, "-p", "no:cacheprovider", *arguments],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_a_timetable_changes_the_settings(ends: Ends, tmp_path: Path) -> None:
    """Its times are since the start: the first line applies to the first datagram."""
    path = tmp_path / "tunnel.csv"
    path.write_text("time_s,words\n0,blackout 0s-3600s\n86400,loss none\n")
    with netem.LossyUdp(ends.server.getsockname(), timetable=path, repeat_s=90_000) as link:
        ends.send(link, range(5))
        wait_for(lambda: link.forward["fates"].get("blacked_out") == 5)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"timetable": "gone.csv"}, "gone.csv: cannot be read: No such file or directory"),
        ({"timetable": 5}, "timetable: 5; give the name of a CSV file"),
        ({"repeat_s": 5}, "repeat_s: 5; there is no timetable"),
        ({"timetable": "t.csv", "repeat_s": 0}, "repeat_s 0: expected more than 0"),
        ({"timetable": "t.csv", "repeat_s": 1e-6}, "repeat_s 1e-06: must be 0.001 s or more"),
        (
            {"timetable": "t.csv", "repeat_s": 2},
            "t.csv: line 3: time_s is 5, but the timetable repeats every 2 s; repeat it later, or leave "
            "the line out",
        ),
    ],
)
def test_a_wrong_timetable_is_refused(
    arguments: dict[str, Any], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("t.csv").write_text("time_s,words\n1,loss 5%\n5,loss none\n")
    with pytest.raises(NoackError) as error:
        netem.LossyUdp("127.0.0.1:9", **arguments)
    assert str(error.value) == line


FAILS = """
import socket

def test_that_no_datagram_arrives(lossy_udp):
    with socket.socket(type=socket.SOCK_DGRAM) as server, socket.socket(type=2) as client:
        server.bind(("127.0.0.1", 0))
        server.settimeout(100)
        link = lossy_udp(server.getsockname(), "loss 50% mansd 6")
        for number in range(80):
            client.sendto(bytes([number]), link.address)
        while link.forward["received"] < 80:
            pass
        fates = link.forward["fates"]
        count = fates.get("delivered", 0) + fates.get("forced", 0)
        assert not [server.recv(1)[0] for _ in range(count)]
"""


def failure(run: subprocess.CompletedProcess[str]) -> tuple[str, str]:
    """Return the list of what arrived, and the seed that the failure names."""
    assert run.returncode == 1, run.stdout
    (arrived,) = (line for line in run.stdout.splitlines() if line.startswith("E ") and "[" in line)
    seed = run.stdout.partition("pytest --noack-seed ")[2].partition(" ")[0]
    assert f"seed {seed}\n  forward: loss 50% mansd 6; 80 received" in run.stdout
    return arrived, seed


def test_a_failure_names_the_seed_that_repeats_it(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(FAILS)
    first = failure(run_pytest(tmp_path, "-vv"))
    assert failure(run_pytest(tmp_path, "-vv", "--noack-seed", first[1])) == first


def test_the_command_that_repeats_a_failure_names_the_test_from_where_pytest_runs(tmp_path: Path) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    folder = tmp_path / "below"
    folder.mkdir()
    (folder / "test_it.py").write_text(
        'def test_it(lossy_udp):\n    lossy_udp("127.0.0.1:9", timetable="t.csv")\n    raise ValueError\n'
    )
    (folder / "t.csv").write_text("time_s,words\n0,loss 5%\n")
    run = run_pytest(folder)
    assert run.stdout.count(" test_it.py::test_it\n") == 1, run.stdout


def test_the_seed_is_that_of_the_option_the_environment_or_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def seed(option: str = "", environment: str = "", file: str = "") -> int:
        monkeypatch.setenv(pytest_plugin.SEED, environment)
        config: Any = SimpleNamespace(getoption=lambda _: option, getini=lambda _: file, stash={})
        pytest_plugin.pytest_configure(config)
        return int(config.stash[pytest_plugin._COMMON])

    assert (seed("1", "2", "3"), seed("", "2", "3"), seed(file="3")) == (1, 2, 3)
    assert seed() != seed()
    for wrong in ("x", "-1", str(2**64)):
        with pytest.raises(pytest.UsageError, match=f"^NOACK_SEED {wrong}: must be 0 or more, below"):
            seed(environment=wrong)


def test_the_test_of_the_documentation_passes(tmp_path: Path) -> None:
    (program,) = blocks("docs/netem-programs.md", "python")
    (tmp_path / "test_repeating_client.py").write_text(program)
    done = run_pytest(tmp_path, "-q")
    assert done.returncode == 0, done.stdout


def arrived_through(ends: Ends, *arguments: str, count: int = 60) -> list[bool]:
    """Return which datagrams arrive through ``noack netem`` with options."""
    command = [sys.executable, "-m", "netem", *arguments, "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        listen = json.loads(process.stdout.readline())["ready"][-1]["listen"]
        host, _, port = listen.rpartition(":")
        for number in range(count):
            ends.client.sendto(number.to_bytes(4), (host, int(port)))
        received: list[int] = []
        for _ in range(4):  # at most three of them are lost
            ends.client.sendto(b"last", (host, int(port)))
        while (data := ends.server.recv(4)) != b"last":
            received.append(int.from_bytes(data))
        process.send_signal(signal.SIGINT)
        (line,) = process.communicate(timeout=60)[0].splitlines()
        assert json.loads(line)["links"][-1]["forward"]["received"] == count + 4
    return [number in received for number in range(count)]


def test_words_and_seed_give_the_same_fates_everywhere(ends: Ends, tmp_path: Path) -> None:
    """In a program, on the command line, and in a file, whatever the link's name and place are there."""
    words = "loss 50% mansd 3"
    to = "{}:{}".format(*ends.server.getsockname())
    expected = arrived(ends, words, 7, 60)
    last = [*words.split(), "--seed", "7"]
    assert arrived_through(ends, "--listen", ":0", "--to", to, *last) == expected
    links = tmp_path / "links.toml"
    other = f'[[link]]\nname = "other"\nlisten = ":0"\nto = "{to}"\nwords = "{words}"\n'
    links.write_text(f"{other}{other.replace('other', 'uplink')}seed = 7\n")
    assert arrived_through(ends, "--links", str(links)) == expected
    first, second = load_links(links)
    assert (first.seed, second.seed) == (0, 7)
    assert first.stream == second.stream
    links.write_text(other + other.replace("other", "uplink"))
    first, second = load_links(links)
    assert first.stream != second.stream  # with the same words, but no seed, their fates differ
