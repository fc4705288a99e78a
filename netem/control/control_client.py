"""Client of live control: sends queries to a running emulator, and receives its statistics."""

import json
import time
from collections.abc import Callable, Iterator
from typing import Any, Self, cast

import zenoh
from zenoh.handlers import RingChannel

from netem.control.emulator_session import EMULATORS, running
from netem.control.emulator_statistics import Statistics
from noack.core.errors import PeerError
from noack.runtime.control_plane import answer_to, cause_of, open_session

_ANSWER_S = 30.0
_SILENCE_S = 3.0
_POLL_S = 0.02


class Client:
    """A connection to the running emulator of this name.

    Raises:
        PeerError: the emulator does not accept the connection.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        try:
            self._session = open_session(EMULATORS, name, listen=False)
        except zenoh.ZError as error:
            raise PeerError(f"emulator {name!r} cannot be reached: {cause_of(error)}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def ask(self, what: str, **content: Any) -> Any:
        """Send the query ``report``, ``settings`` or ``change``, and return the answer.

        Raises:
            CallerError: the query has a mistake.
            PeerError: there is no answer.
        """
        key = f"netem/{self._name}/{what}"
        answer = answer_to(self._session, key, json.dumps(content), _ANSWER_S)
        if answer is not None:
            return json.loads(answer)
        raise PeerError(f"emulator {self._name!r} does not answer")

    def follow(self, stop: Callable[[], bool]) -> Iterator[Statistics]:
        """Yield the statistics that the emulator publishes, until ``stop()``.

        Raises:
            PeerError: the emulator has ended.
        """
        key = f"netem/{self._name}/statistics"
        with self._session.declare_subscriber(key, RingChannel(2)) as subscriber:
            received_s = time.monotonic()
            while not stop():
                sample = subscriber.try_recv()
                if sample is not None:
                    received_s = time.monotonic()
                    yield cast(Statistics, json.loads(sample.payload.to_string()))
                elif time.monotonic() < received_s + _SILENCE_S:
                    time.sleep(_POLL_S)
                elif self._name not in running():
                    raise PeerError(f"emulator {self._name!r} has ended")
                else:
                    received_s = time.monotonic()
