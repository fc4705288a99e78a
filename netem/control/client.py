"""The other side of live control: asks a running emulator, and follows its statistics."""

import json
import time
from collections.abc import Callable, Iterator
from typing import Any, Self, cast

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from netem.control.server import USER
from netem.control.session import Session, running
from netem.control.statistics import Statistics
from noack.errors import CallerError, PeerError
from noack.io.plane import cause_of, star_config

_ANSWER_S = 10.0
_SILENCE_S = 3.0
_POLL_S = 0.02


class Client:
    """A connection to a running emulator.

    Args:
        session: how to reach it, from :func:`netem.control.session.find`.

    Raises:
        PeerError: it cannot be reached.
    """

    def __init__(self, session: Session) -> None:
        self._name = session.name
        self._token = session.token
        secret = {"transport/auth/usrpwd/user": USER, "transport/auth/usrpwd/password": self._token}
        try:
            self._session = zenoh.open(star_config(session.endpoint, listen=False, more=secret))
        except zenoh.ZError as error:
            raise PeerError(
                f"emulator {self._name!r} cannot be reached at {session.endpoint}: "
                f"{cause_of(error)}"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def ask(self, what: str, **content: Any) -> Any:
        """Ask ``report``, ``settings`` or ``change``, and return the answer.

        Raises:
            CallerError: what was asked for is wrong; one line.
            PeerError: there is no answer.
        """
        payload = json.dumps(content | {"token": self._token})
        key = f"netem/{self._name}/{what}"
        replies = self._session.get(key, FifoChannel(4), payload=payload, timeout=_ANSWER_S)
        deadline_s = time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline_s:
            try:
                reply = replies.try_recv()
            except zenoh.ZError:  # the query has ended without an answer
                break
            if reply is None:
                time.sleep(0.002)
            elif reply.ok is not None:
                return json.loads(reply.ok.payload.to_string())
            elif reply.err is not None:
                raise CallerError(reply.err.payload.to_string())
        raise PeerError(f"emulator {self._name!r} does not answer")

    def follow(self, stop: Callable[[], bool]) -> Iterator[Statistics]:
        """Yield the statistics that the emulator publishes, until ``stop()``.

        Raises:
            PeerError: the emulator has ended.
        """
        key = f"netem/{self._name}/statistics"
        with self._session.declare_subscriber(key, RingChannel(2)) as subscriber:
            heard_s = time.monotonic()
            while not stop():
                sample = subscriber.try_recv()
                if sample is not None:
                    heard_s = time.monotonic()
                    yield cast(Statistics, json.loads(sample.payload.to_string()))
                elif time.monotonic() < heard_s + _SILENCE_S:
                    time.sleep(_POLL_S)
                elif self._name not in running():
                    raise PeerError(f"emulator {self._name!r} has ended")
                else:
                    heard_s = time.monotonic()
