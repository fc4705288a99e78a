"""The socket of a probe: times of arrival, what the kernel drops, sends that nobody receives."""

import socket
import sys
import time

import pytest

from cosim.measurement.live_measurement import ProbeSocket, host_number

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="time stamps of Linux")
WAIT_S = 0.05


@on_linux
def test_an_arrival_has_the_time_at_which_it_came_not_that_of_reading() -> None:
    receiver = ProbeSocket(listen=("127.0.0.1", 0))
    sender = ProbeSocket(peer=receiver.endpoint.getsockname())
    with receiver.endpoint, sender.endpoint:
        for _ in range(20):  # a process that is stalled meanwhile cannot compare its clocks
            before_ns = time.monotonic_ns()
            sender.send(b"datagram")
            after_ns = time.monotonic_ns()
            time.sleep(WAIT_S)
            (arrival,) = receiver.receive()
            assert receiver.receive() == []
            assert arrival.data == b"datagram"
            # On loopback it arrives before send returns; the clocks are compared within 20 µs.
            if before_ns - 100_000 < arrival.latest_ns < after_ns + 100_000:
                break
        else:
            pytest.fail("no arrival has the time at which it came")


@on_linux
def test_what_the_kernel_drops_is_counted() -> None:
    receiver = ProbeSocket(listen=("127.0.0.1", 0))
    with receiver.endpoint, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        receiver.endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for _ in range(200):
            sender.sendto(bytes(1000), receiver.endpoint.getsockname())
        read = len(receiver.receive())
        assert 0 < read < 200
        assert receiver.kernel_drops == 200 - read


@on_linux
def test_a_send_that_nobody_receives_is_counted() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        address = closed.getsockname()
    sender = ProbeSocket(peer=address)
    with sender.endpoint:
        for _ in range(3):
            sender.send(b"datagram")
            sender.receive()
        assert sender.send_errors >= 3
        assert "refused" in sender.last_send_error


@on_linux
def test_the_host_has_a_number_that_stays() -> None:
    assert host_number() == host_number() > 0
