"""Times of arrival from the kernel, a clock that is set, and datagrams that nobody reads."""

import socket
import sys
import time

import pytest

from cosim.measurement.live import stamped_socket
from cosim.measurement.live.stamped_socket import StampedSocket, host_number

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="time stamps of Linux")
WAIT_S = 0.3


def test_an_arrival_has_the_time_at_which_it_came_not_that_of_reading() -> None:
    receiver = StampedSocket(listen=("127.0.0.1", 0))
    sender = StampedSocket(to=receiver.endpoint.getsockname())
    with receiver.endpoint, sender.endpoint:
        for _ in range(20):  # a process that is stalled meanwhile cannot compare its clocks
            before_ns = time.monotonic_ns()
            sender.send(b"datagram")
            after_ns = time.monotonic_ns()
            time.sleep(WAIT_S)
            arrival = receiver.receive()
            assert receiver.receive() is None
            assert arrival is not None
            assert arrival.data == b"datagram"
            # On loopback it arrives before send returns; the clocks are compared within 20 µs.
            if before_ns - 100_000 < arrival.received_ns < after_ns + 100_000:
                break
        else:
            pytest.fail("no arrival has the time at which it came")


def test_a_clock_that_is_set_does_not_move_an_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    receiver = StampedSocket(listen=("::1", 0))
    sender = StampedSocket(to=receiver.endpoint.getsockname()[:2])
    with receiver.endpoint, sender.endpoint:
        before_ns = time.monotonic_ns()
        sender.send(b"datagram")
        real_ns = time.time_ns
        monkeypatch.setattr(stamped_socket, "_PREEMPTED_NS", 10**12)
        monkeypatch.setattr(stamped_socket.time, "time_ns", lambda: real_ns() - 3600 * 10**9)
        arrival = receiver.receive()
        after_ns = time.monotonic_ns()
    assert arrival is not None
    assert before_ns < arrival.received_ns <= after_ns
    assert receiver.clock_sets == 1


def test_what_the_kernel_drops_is_counted() -> None:
    receiver = StampedSocket(listen=("127.0.0.1", 0))
    with receiver.endpoint, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        receiver.endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for _ in range(200):
            sender.sendto(bytes(1000), receiver.endpoint.getsockname())
        read = 0
        while receiver.receive() is not None:
            read += 1
        assert 0 < read < 200
        assert receiver.kernel_drops == 200 - read


def test_the_host_has_a_number_that_stays() -> None:
    assert host_number() == host_number() > 0
