import socket
from collections.abc import Iterator

import pytest

import noack.runtime.reachability
from noack.runtime.address import LOOPBACK, Address
from noack.runtime.reachability import why_unreachable


@pytest.fixture
def bound() -> Iterator[socket.socket]:
    """A socket with a port of its own, which does not listen yet."""
    with socket.socket() as endpoint:
        endpoint.bind((LOOPBACK, 0))
        yield endpoint


def test_a_port_where_nothing_listens(bound: socket.socket) -> None:
    assert why_unreachable(bound.getsockname()).startswith("nothing listens there")


def test_a_program_with_other_keys(bound: socket.socket) -> None:
    bound.listen()
    assert "does not accept this invitation" in why_unreachable(bound.getsockname())


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (TimeoutError(), "no answer; is it the recording host's address? Do firewalls"),
        (OSError(113, ""), "No route to host"),
    ],
)
def test_what_the_system_reports(
    monkeypatch: pytest.MonkeyPatch, error: OSError, text: str
) -> None:
    def refuse(address: Address, timeout: float) -> None:
        raise error

    monkeypatch.setattr(noack.runtime.reachability.socket, "create_connection", refuse)
    assert why_unreachable(("192.0.2.1", 7400)).startswith(text)
