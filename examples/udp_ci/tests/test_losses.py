"""The client under losses, under datagrams that come twice and out of order, and in an outage."""

import socket
from collections.abc import Iterator
from threading import Event, Thread

import pytest
from thermo.client import NoAnswerError, ask
from thermo.server import TEMPERATURES, serve

TRIES = 100
"""A slow machine costs tries, too; a test must not fail because of it."""


@pytest.fixture
def server() -> Iterator[tuple[str, int]]:
    """The address of a server that runs."""
    stop = Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        thread = Thread(target=serve, args=(listening, stop))
        thread.start()
        yield listening.getsockname()
        stop.set()
        thread.join()


def test_an_answer_comes_although_most_datagrams_are_lost(server, lossy_udp):
    link = lossy_udp(server, "loss 70% mansd 2", reverse="loss 70% mansd 2")
    assert ask(link.address, "boiler", tries=TRIES) == TEMPERATURES["boiler"]
    assert link.forward["longest_loss_burst"] <= 2
    assert link.reverse["longest_loss_burst"] <= 2


def test_answers_that_come_twice_and_out_of_order_are_not_mixed_up(server, lossy_udp):
    words = "duplicate 50% delay 5ms 4ms"
    link = lossy_udp(server, words, reverse=words)
    for _ in range(10):
        for place, temperature in TEMPERATURES.items():
            assert ask(link.address, place, tries=TRIES) == temperature


def test_an_outage_is_reported(server, lossy_udp):
    link = lossy_udp(server, "loss 100%")
    with pytest.raises(NoAnswerError, match="room: no answer to 3 questions"):
        ask(link.address, "room", tries=3)
