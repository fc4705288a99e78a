"""A server and a client for network namespaces, run by the path of this file.

``counter.py count HOST`` prints its port and, when its standard input ends, the number received.
``counter.py send HOST PORT COUNT`` sends COUNT datagrams.
"""

import socket
import sys
import threading

QUIET_S = 0.3
"""Longer than the travel time of the last datagram after it has left the queue."""
SIZE_BYTES = 500


def udp_socket(host: str) -> socket.socket:
    return socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)


def count(host: str) -> None:
    with udp_socket(host) as server:
        server.bind((host, 0))
        print(server.getsockname()[1], flush=True)
        server.settimeout(QUIET_S)
        received = 0
        ended = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), ended.set())).start()
        while True:
            ending = ended.is_set()
            try:
                server.recv(2048)
            except TimeoutError:
                if ending:
                    print(received, flush=True)
                    return
            else:
                received += 1


def send(host: str, port: str, number: str) -> None:
    with udp_socket(host) as client:
        for _ in range(int(number)):
            client.sendto(bytes(SIZE_BYTES), (host, int(port)))


if __name__ == "__main__":
    {"count": count, "send": send}[sys.argv[1]](*sys.argv[2:])
