"""Where a run may listen, and what its scenario records then."""

from pathlib import Path

import pytest

from cosim.live.remote_access import listen_address, with_clocks
from noack.config.scenario_file import load
from noack.config.sections.run_sections import ClocksSection
from noack.core.errors import CallerError


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
