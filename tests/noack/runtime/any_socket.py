"""A process's socket in the loop, and its senders."""

import select
import socket

import numpy as np

from noack.protocol.machine_interface import Notice
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message
from noack.runtime.udp_sockets import LOOPBACK, MessageSocket, bind

RUN_ID, KEY = 7, bytes(range(32))


def opened() -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.bind((LOOPBACK, 0))
    endpoint.setblocking(False)
    return endpoint


class Ear:
    """A sensor's socket, which receives measurements of two entries from ``peer``."""

    def __init__(self, peer: socket.socket, endpoint: socket.socket | None = None) -> None:
        self._endpoint = bind(0, "port") if endpoint is None else endpoint
        self.decoder = Decoder(Flow.MEASUREMENT, 2, RUN_ID, KEY)
        self.encoder = Encoder(RUN_ID, KEY)
        self.address = self._endpoint.getsockname()
        self.channel = MessageSocket(
            self._endpoint, self.decoder, self.encoder, Flow.UPDATE,
            source=peer.getsockname(), destination=peer.getsockname(),
        )  # fmt: skip
        self.lines: list[Notice] = []

    @staticmethod
    def message(sequence: int) -> Message:
        return Message(Flow.MEASUREMENT, sequence, sequence, np.array([1.0, 2.0]))

    def turns(self, most: int) -> list[int]:
        """Call the socket as the loop does, at most ``most`` times; return the sequence numbers."""
        heard = []
        for _ in range(most):
            readable, _, _ = select.select(self.channel.watched, (), (), 0)
            if not readable:
                break
            message = self.channel.receive(readable[0])
            if message is not None:
                heard.append(message.sequence)
        return heard

    def tend(self) -> None:
        self.lines += self.channel.tend(0)

    def close(self) -> None:
        self.channel.close()
        self._endpoint.close()


def sent_to(ear: Ear, sender: socket.socket, data: bytes) -> None:
    sender.sendto(data, ear.address)
