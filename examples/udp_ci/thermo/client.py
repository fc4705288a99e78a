"""The client: repeats its question until the answer comes."""

import socket
import sys


class NoAnswerError(Exception):
    """No answer came to any of the questions."""


def ask(address: tuple[str, int], place: str, *, tries: int = 12, wait_s: float = 0.2) -> float:
    """Return the temperature of a place.

    Each question has a number, and only an answer with its number counts: a late answer to an earlier
    question would be an old temperature.

    Raises:
        NoAnswerError: no answer came.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(wait_s)
        client.connect(address)
        for number in range(tries):
            client.send(f"{number} {place}".encode())
            try:
                while True:
                    found, _, temperature = client.recv(1500).decode().partition(" ")
                    if found == str(number):
                        return float(temperature)
            except (TimeoutError, ConnectionRefusedError):
                continue
    raise NoAnswerError(f"{place}: no answer to {tries} questions")


def main() -> None:
    """Print the temperature of a place: HOST PORT PLACE."""
    host, port, place = sys.argv[1:]
    print(ask((host, int(port)), place))


if __name__ == "__main__":
    main()
