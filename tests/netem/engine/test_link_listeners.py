"""Links that cannot be opened are refused."""

from collections.abc import Sequence
from itertools import pairwise

import pytest

from netem.relay_links import LinkSpec, open_links
from noack.core.errors import CallerError
from tests.netem.engine.relays import HOSTS, endpoints, link, name_of


def open_and_close(specs: Sequence[LinkSpec]) -> None:
    for opened in open_links(specs):
        opened.close()


def free_port(host: str) -> int:
    with endpoints(host) as (one,):
        return name_of(one)[1]


@pytest.mark.parametrize(
    ("listen", "to"),
    [
        ("127.0.0.1", "127.0.0.1"), ("::1", "::1"), ("0.0.0.0", "127.0.0.1"),
        ("127.0.0.1", "0.0.0.0"), ("0.0.0.0", "127.1.2.3"), ("::", "::1"), ("::", "127.0.0.1"),
        ("::1", "::"),
    ],
)  # fmt: skip
def test_a_link_that_leads_back_to_itself_is_refused(listen: str, to: str) -> None:
    port = free_port(listen)
    with pytest.raises(CallerError, match=r"leads back to itself$"):
        open_and_close([link((to, port), listen=(listen, port))])


def test_a_link_to_the_same_port_of_another_address_is_allowed() -> None:
    for listen, to in (("127.0.0.1", "127.0.0.2"), ("0.0.0.0", "192.0.2.1")):
        port = free_port(listen)
        open_and_close([link((to, port), listen=(listen, port))])


def test_links_may_form_a_chain_but_not_a_cycle() -> None:
    ports = {name: free_port(HOSTS[4]) for name in "abc"}

    def chain(*names: str) -> list[LinkSpec]:
        return [
            link((HOSTS[4], ports[to]), listen=(HOSTS[4], ports[name]), name=name)
            for name, to in pairwise(names)
        ]

    open_and_close(chain("a", "b", "c"))
    with pytest.raises(CallerError, match=r"^link b: .* leads back to itself over c$"):
        open_and_close(chain("a", "b", "c", "b"))


def test_an_impossible_link_is_refused() -> None:
    there = ("127.0.0.1", 9)
    with endpoints(HOSTS[4]) as (other,):
        for specs, message in (
            ([link(there, listen=("localhost", 0))], "not an address of IPv4 or IPv6"),
            ([link(there, listen=("192.0.2.1", 0))], "is no address of this machine"),
            ([link(("127.0.0.1", 0))], "^link test: to 127.0.0.1:0: nobody can be at port 0"),
            ([link(there, listen=name_of(other))], "already taken"),
            ([link(there)] * 2, "two of this name"),
        ):
            with pytest.raises(CallerError, match=message):
                open_and_close(specs)
