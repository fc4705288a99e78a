"""Servers and clients for network namespaces, run by the path of this file.

``echo.py serve HOST`` prints its port, then the source address of each datagram, one per line.
``echo.py ask HOST PORT FROM_HOST FROM_PORT COUNT`` sends COUNT datagrams one after the other, each
with its number only, and prints the numbers that came back.
``echo.py count HOST`` prints its port and, at the end of its standard input, the number received.
``echo.py send HOST PORT COUNT`` sends COUNT datagrams.
"""

import json
import socket
import sys
import threading
from contextlib import suppress

TIMEOUT_S = 0.05
QUIET_S = 0.3
"""Longer than the travel time of the last datagram after it has left the queue."""
SIZE_BYTES = 500
SO_RCVBUFFORCE = 33
BUFFER_BYTES = 4 * 1024 * 1024


def family_of(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def serve(host: str) -> None:
    with socket.socket(family_of(host), socket.SOCK_DGRAM) as server:
        server.bind((host, 0))
        print(server.getsockname()[1], flush=True)
        while True:
            data, source = server.recvfrom(2048)
            print(json.dumps([source[0], source[1], data.decode()]), flush=True)
            server.sendto(data, source)


def ask(host: str, port: str, from_host: str, from_port: str, count: str) -> None:
    came = []
    with socket.socket(family_of(host), socket.SOCK_DGRAM) as client:
        client.bind((from_host, int(from_port)))
        client.connect((host, int(port)))
        client.settimeout(TIMEOUT_S)
        for number in range(int(count)):
            client.send(f"{from_host} {number}".encode())
            with suppress(TimeoutError):
                came.append(client.recv(2048).decode())
        with suppress(TimeoutError):  # the answer is late or lost
            while True:
                came.append(client.recv(2048).decode())
    print(json.dumps(came))


def count(host: str) -> None:
    with socket.socket(family_of(host), socket.SOCK_DGRAM) as server:
        server.bind((host, 0))
        print(server.getsockname()[1], flush=True)
        server.settimeout(QUIET_S)
        server.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES)
        came = 0
        ended = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), ended.set())).start()
        while True:
            ending = ended.is_set()
            try:
                server.recv(2048)
            except TimeoutError:
                if ending:
                    print(came, flush=True)
                    return
            else:
                came += 1


def send(host: str, port: str, count: str) -> None:
    with socket.socket(family_of(host), socket.SOCK_DGRAM) as client:
        for _ in range(int(count)):
            client.sendto(bytes(SIZE_BYTES), (host, int(port)))


if __name__ == "__main__":
    {"serve": serve, "ask": ask, "count": count, "send": send}[sys.argv[1]](*sys.argv[2:])
