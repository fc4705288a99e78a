"""The two ends of a test of the shell, which run inside and outside; they use Python alone.

The server sends each numbered datagram back, and answers which ones it has received. The client
writes the numbers that arrived there and back as JSON. Questions can be lost, and are repeated.
"""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

PATIENCE_S = 0.1
FAMILIES = {"ipv4": socket.AF_INET, "ipv6": socket.AF_INET6}
OUTSIDE = {"ipv4": "NOACK_OUTSIDE", "ipv6": "NOACK_OUTSIDE6"}


def serve(ready: Path) -> None:
    received: dict[str, int] = {}
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("::", 0))
        (partial := ready.with_suffix(".part")).write_text(str(endpoint.getsockname()[1]))
        partial.rename(ready)
        while True:
            data, client = endpoint.recvfrom(65536)
            flow, _, number = data.decode().partition(" ")
            if number == "?":
                endpoint.sendto(f"{flow} {received.get(flow, 0):x}".encode(), client)
            elif number:
                received[flow] = received.get(flow, 0) | 1 << int(number)
                endpoint.sendto(data, client)


class Client:
    """The client's end; one socket has all questions: a late answer to a closed one is an error."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._questions = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._questions.connect((os.environ["NOACK_OUTSIDE"], port))
        self._questions.settimeout(PATIENCE_S)
        self._questions.send(b"x" * 4000)  # fragments

    def ask(self, flow: str) -> list[int]:
        """Return the numbers of a flow that the server has received."""
        while True:
            self._questions.send(f"{flow} ?".encode())
            with suppress(TimeoutError):
                answered, numbers = self._questions.recv(1000).decode().split()
                if answered == flow:
                    received = int(numbers, 16)
                    return [k for k in range(received.bit_length()) if received >> k & 1]

    def exchange(self, flow: str, count: int, interrupt: Callable[[int, str], None]) -> dict[str, object]:
        """Send numbered datagrams; return the client's port, and what came there and back."""
        back: list[int] = []
        with socket.socket(FAMILIES[flow], socket.SOCK_DGRAM) as endpoint:
            endpoint.connect((os.environ[OUTSIDE[flow]], self._port))
            for number in range(count):
                endpoint.send(f"{flow} {number}".encode())
                interrupt(number, str(endpoint.getsockname()[1]))
            there = self.ask(flow)  # what was sent back before the answer has arrived
            with suppress(BlockingIOError):
                while True:
                    back.append(int(endpoint.recv(1000, socket.MSG_DONTWAIT).split()[1]))
            return {"port": endpoint.getsockname()[1], "there": there, "back": back}


def change_after(last: int, words: str, name: str) -> Callable[[int, str], None]:
    """Return what changes the emulator when it has received a datagram."""
    netem = [sys.executable, "-m", "netem"]

    def interrupt(number: int, port: str) -> None:
        while number == last:
            shown = subprocess.run([*netem, "show", name, "--json"], capture_output=True, check=True)
            flows = json.loads(shown.stdout)["links"][0]["forward"]["flows"]
            if any(f":{port} " in flow["client"] and flow["packets"] > number for flow in flows):
                subprocess.run([*netem, "set", name, *words.split()], check=True)
                break

    return interrupt


def main() -> None:
    role, folder, *arguments = sys.argv[1:]
    ready = Path(folder, "ready")
    if role == "server":
        serve(ready)
    while not ready.exists():
        time.sleep(0.01)
    count, *change = arguments
    port = int(ready.read_text())
    interrupt = change_after(int(change[0]), *change[1:]) if change else lambda _number, _port: None
    flows = ["ipv4"] if change or "NOACK_OUTSIDE6" not in os.environ else ["ipv4", "ipv6"]
    client = Client(port)
    exchanges = {flow: client.exchange(flow, int(count), interrupt) for flow in flows}
    Path(folder, "ends.json").write_text(json.dumps(exchanges))


if __name__ == "__main__":
    main()
