"""Addresses in text form."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.errors import CallerError
from noack.runtime.address import Address, family_of, parse_address, parse_destination, text_of


@given(st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6)), st.integers(0, 65_535))
def test_addresses_survive_formatting_and_parsing(host: object, port: int) -> None:
    address = (str(host), port)
    read = parse_address(text_of(address), "here")
    family = family_of(address)
    assert socket.inet_pton(family, read[0]) == socket.inet_pton(family, address[0])
    assert read[1] == port


@pytest.mark.parametrize(
    ("text", "like", "address"),
    [
        (":9000", None, ("127.0.0.1", 9000)),
        (":9000", ("::1", 1), ("::1", 9000)),
        ("localhost:9000", None, ("127.0.0.1", 9000)),
        ("[::1]:9000", ("192.0.2.1", 1), ("::1", 9000)),
    ],
)
def test_a_missing_host_means_loopback_of_the_same_family(
    text: str, like: Address | None, address: Address
) -> None:
    assert parse_address(text, "here", like) == address


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "here: expected HOST:PORT, e.g. 127.0.0.1:9000, [::1]:9000 or :9000; found ''"),
        ("host:65536", "expected HOST:PORT"),
        ("::1:9000", "found '::1:9000'; put an IPv6 address in brackets"),
        ("[127.0.0.1]:9000", "here: 127.0.0.1: no such host ("),
    ],
)
def test_a_mistake_gets_one_line(text: str, says: str) -> None:
    with pytest.raises(CallerError) as caught:
        parse_address(text, "here")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_destination_has_a_port() -> None:
    assert parse_destination(":9001", "--to") == ("127.0.0.1", 9001)
    with pytest.raises(CallerError, match="--to: expected a port from 1 to 65535; found ':0'"):
        parse_destination(":0", "--to")
