"""Where a run may listen, and the file that places processes on other hosts."""

from collections import Counter
from pathlib import Path

import pytest

from cosim.live.remote_access import (
    ConnectionFloodWatch,
    listen_address,
    listening_for,
    with_clocks,
)
from noack.core.errors import CallerError
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import load

ROBOT = '[controller]\nssh = "robot"\n'
UNREACHABLE = "not an address at which other hosts can reach this one"
LISTEN = 'listen = "192.0.2.1"\n'


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("192.0.2.1", ("192.0.2.1", 0)),
        ("192.0.2.1:7400", ("192.0.2.1", 7400)),
        ("2001:db8::1", ("2001:db8::1", 0)),
        ("[2001:db8::1]:7400", ("2001:db8::1", 7400)),
        ("127.0.0.1", ("127.0.0.1", 0)),
    ],
)
def test_an_address_may_lack_its_port(text: str, address: tuple[str, int]) -> None:
    assert listen_address(text) == address


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("0.0.0.0", UNREACHABLE),
        ("::", UNREACHABLE),
        ("fe80::1", UNREACHABLE),
        ("::ffff:1.2.3.4", UNREACHABLE),
        ("", "--listen: expected an address of this host"),
        (":7400", "--listen: expected an address of this host"),
        ("host.invalid", "--listen: host.invalid: no such host"),
        ("192.0.2.1:port", "--listen: expected HOST:PORT"),
    ],
)
def test_an_address_that_others_cannot_reach_is_refused(text: str, reason: str) -> None:
    with pytest.raises(CallerError, match=reason):
        listen_address(text)


def test_one_loop_records_the_bounds_of_its_clocks() -> None:
    one = load(Path("scenarios/lane_following.toml"))
    assert with_clocks(one).clocks == ClocksSection()
    strict = one.model_copy(update={"clocks": ClocksSection(largest_error_us=5.0)})
    assert with_clocks(strict) is strict


def test_a_flood_of_connections_is_reported_at_its_begin_and_end() -> None:
    watch = ConnectionFloodWatch()

    def lines(*counts: int) -> list[str]:
        for count in counts:
            watch.next_interval(Counter({"192.0.2.7": count, "192.0.2.8": count // 2}))
        return [watch.lines.get_nowait() for _ in range(watch.lines.qsize())]

    assert lines(3, 0, 40) == []
    (begin,) = lines(4000, 4000)
    assert begin == (
        "flood: 6000 connections without an invitation in a second, from 2 addresses, most from "
        "192.0.2.7; processes with an invitation can still join"
    )
    assert lines(0, 0, 4000, 0, 0) == []
    assert lines(0) == ["the flood is over: 18000 connections without an invitation ended"]
    assert len(lines(4000, 0, 0, 0)) == 1  # the next end is reported later
    assert len(lines(0, 0, 0)) == 1


@pytest.fixture
def hosts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of hosts, on a machine with an ssh client."""
    script = tmp_path / "bin" / "ssh"
    script.parent.mkdir()
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(script.parent))
    return tmp_path / "hosts.toml"


def test_processes_without_a_table_stay_here(hosts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hosts.write_text(f'listen = "192.0.2.1:7400"\n{ROBOT}')
    found = listening_for(hosts)
    assert found.address == ("192.0.2.1", 7400)
    assert found.invitation is None
    assert {role: host.ssh for role, host in found.hosts.items()} == {"controller": "robot"}
    monkeypatch.setenv("PATH", str(hosts.parent))
    with pytest.raises(CallerError, match="no ssh client is installed"):
        listening_for(hosts)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (ROBOT, "hosts.toml: listen: missing"),
        (LISTEN, "no process is on another host"),
        (f'listen = "0.0.0.0"\n{ROBOT}', "hosts.toml: listen: 0.0.0.0 is not an address"),
        (f'{LISTEN}[recorder]\nssh = "robot"\n{ROBOT}', "the keys here are controller"),
        (f'{LISTEN}[plant]\nssh = "-oProxyCommand=reboot"\n', "plant.ssh"),
        (f'{LISTEN}plant = "robot"\n', "plant"),
        (f'{LISTEN}[plant]\nssh = "a\\u0000b"\n', "has a control character"),
        (f'{LISTEN}{ROBOT}command = "a\\u0000"\n', "controller.command"),
        (f'{LISTEN}{ROBOT}runs = "a\\nb"\n', "controller.runs"),
    ],
)
def test_a_mistake_gives_one_line(hosts: Path, text: str, line: str) -> None:
    hosts.write_text(text)
    with pytest.raises(CallerError) as caught:
        listening_for(hosts)
    assert line in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
