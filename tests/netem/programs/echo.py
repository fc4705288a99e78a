"""Servers and clients that are run in network namespaces, by their path.

``echo.py serve HOST`` says its port, and for each datagram from where it came, a line each.
``echo.py ask HOST PORT FROM_HOST FROM_PORT COUNT`` sends so many datagrams, one after the other,
with nothing but their numbers, and says which numbers came back.
``echo.py count HOST`` says its port and, when its standard input has ended, how many came.
``echo.py send HOST PORT COUNT`` sends so many datagrams.
"""

import json
import socket
import sys
import threading
from contextlib import suppress

TIMEOUT_S = 0.1
QUIET_S = 1.0
"""The last datagram on its way takes less, once it has left the queue that it waits in."""
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
        with suppress(TimeoutError):  # what is late
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
