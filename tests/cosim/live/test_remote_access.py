"""Where a run may listen, and what its scenario records then."""

from collections import Counter
from pathlib import Path

import pytest

from cosim.live.remote_access import ConnectionFloodWatch, listen_address, with_clocks
from noack.core.errors import CallerError
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import load


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("192.0.2.1", ("192.0.2.1", 0)),
        ("192.0.2.1:7400", ("192.0.2.1", 7400)),
        ("2001:db8::1", ("2001:db8::1", 0)),
        ("[2001:db8::1]", ("2001:db8::1", 0)),
        ("[2001:db8::1]:7400", ("2001:db8::1", 7400)),
        ("127.0.0.1", ("127.0.0.1", 0)),
    ],
)
def test_an_address_may_lack_its_port(text: str, address: tuple[str, int]) -> None:
    assert listen_address(text) == address


@pytest.mark.parametrize(
    "text", ["0.0.0.0", "::", "224.0.0.1", "fe80::1", "169.254.1.1:7400", "::ffff:1.2.3.4"]
)
def test_an_address_that_others_cannot_reach_is_refused(text: str) -> None:
    with pytest.raises(CallerError, match="not an address at which other hosts can reach this one"):
        listen_address(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "--listen: expected an address of this host"),
        (":7400", "--listen: expected an address of this host"),
        ("host.invalid", "--listen: host.invalid: no such host"),
        ("192.0.2.1:port", "--listen: expected HOST:PORT"),
    ],
)
def test_what_is_no_address_is_named(text: str, reason: str) -> None:
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
