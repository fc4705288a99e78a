"""The server: answers `NUMBER PLACE` with `NUMBER TEMPERATURE`."""

import socket
import sys
from threading import Event

TEMPERATURES = {"boiler": 61.5, "room": 20.25, "outside": -3.0}


def answer(question: bytes) -> bytes | None:
    """Return the answer to a datagram, or None if it is no question."""
    number, _, place = question.decode(errors="replace").partition(" ")
    if not number.isdecimal() or place not in TEMPERATURES:
        return None
    return f"{number} {TEMPERATURES[place]}".encode()


def serve(server: socket.socket, stop: Event) -> None:
    """Answer questions until somebody sets ``stop``."""
    server.settimeout(0.1)
    while not stop.is_set():
        try:
            question, client = server.recvfrom(1500)
        except TimeoutError:
            continue
        if (text := answer(question)) is not None:
            server.sendto(text, client)


def main() -> None:
    """Serve on the port that the command line names."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", int(sys.argv[1])))
        serve(server, Event())


if __name__ == "__main__":
    main()
