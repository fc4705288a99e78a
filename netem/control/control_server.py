"""Live control of a relay over zenoh, on loopback.

A running emulator listens on a free TCP port of the loopback interface and says where in its
session file (:mod:`netem.control.emulator_session`). Below ``netem/NAME`` it

* answers ``report``: statistics (:mod:`netem.control.emulator_statistics`);
* answers ``settings``: what each link does, in words and as settings;
* answers ``change``: new settings for a link, which it checks, and answers as ``settings`` does;
* publishes ``statistics`` once a second.

A query is a JSON object. It must hold ``token``, the secret of the session file; ``change`` takes
``link`` (may be left out if there is one), ``direction`` (``forward``, the default, ``back`` or
``both``) and either ``words`` (of ``tc netem``) or ``settings`` (a
:class:`~noack.impairments.link_settings.LinkSettings`). As with ``tc qdisc change``, the new
settings replace the old; files that words name are read before they are sent. What is wrong with a
query is answered in one line, and nothing is changed.

Nobody without the secret gets in: zenoh's connections ask for it as a password (by challenge and
response, so that it is never sent), and each query is checked for it again.

All of this happens in a thread of its own; see :mod:`netem.control.command_queue`.
"""

import hmac
import json
import secrets
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any, Literal, Self

import zenoh
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from zenoh import CongestionControl, Priority
from zenoh.handlers import RingChannel

from netem.control.command_queue import CommandQueue, Snapshot
from netem.control.emulator_session import Session, published
from netem.control.emulator_statistics import statistics
from netem.engine.relay_interface import DIRECTIONS, Direction
from netem.words.words_to_settings import settings_of, text_of
from noack.config.validation_messages import brief
from noack.core.errors import CallerError, MachineError, NoackError, PeerError
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.trace import TraceLoss
from noack.runtime.udp_sockets import LOOPBACK, free_tcp_port
from noack.runtime.zenoh_session import SessionSecret, cause_of, open_session

_TOKEN_BYTES = 32
_POLL_S = 0.02
_PUBLISH_S = 1.0
_QUERIES = 64
"""Of each kind wait at most; the oldest give way."""
_PATIENCE_S = 10.0


def secret_of(token: str) -> SessionSecret:
    """Return what zenoh asks for whoever connects."""
    return SessionSecret("netem", token)


class SettingsChange(BaseModel):
    """What a query for ``change`` says."""

    model_config = ConfigDict(extra="forbid", strict=True)

    link: str | None = None
    direction: Literal["forward", "back", "both"] = "forward"
    words: str | list[str] | None = None
    settings: LinkSettings | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.words is None) == (self.settings is None):
            raise ValueError("give words, or settings")
        return self


class ControlServer:
    """Answers queries about a relay, and changes it, while the context lasts.

    Args:
        name: the emulator's name.
        errands: how to reach the relay.

    Raises:
        CallerError: the name is unfit or in use.
        MachineError: no port can be listened on.
    """

    def __init__(self, name: str, commands: CommandQueue) -> None:
        self._name = name
        self._errands = commands
        self._token = secrets.token_hex(_TOKEN_BYTES)
        self._snapshots: deque[Snapshot] = deque(maxlen=2)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="netem control", daemon=True)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            endpoint = f"tcp/{LOOPBACK}:{free_tcp_port()}"
            self._session = self._open(endpoint)
            stack.callback(self._session.close)
            self._queryables = [
                (self._session.declare_queryable(self._key(what), RingChannel(_QUERIES)), answer)
                for what, answer in (
                    ("report", self._report),
                    ("settings", self._settings),
                    ("change", self._change),
                )
            ]
            stack.enter_context(published(Session(self._name, endpoint, self._token)))
            self._thread.start()
            stack.callback(self._thread.join, _PATIENCE_S)
            stack.callback(self._stopping.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open(self, endpoint: str) -> zenoh.Session:
        try:
            return open_session(endpoint, secret_of(self._token), listen=True)
        except zenoh.ZError as error:
            raise MachineError(f"cannot listen on {endpoint}: {cause_of(error)}") from None

    def _key(self, what: str) -> str:
        return f"netem/{self._name}/{what}"

    def _serve(self) -> None:
        """Answer, and publish, until stopped."""
        publish_s = time.monotonic()
        while not self._stopping.wait(_POLL_S):
            for queryable, answer in self._queryables:
                while (query := queryable.try_recv()) is not None:
                    self._reply(query, answer)
            if time.monotonic() >= publish_s:
                publish_s = max(publish_s + _PUBLISH_S, time.monotonic())
                with suppress(PeerError):
                    self._publish()

    def _publish(self) -> None:
        self._snapshots.append(self._errands.snapshot())
        before = self._snapshots[0] if len(self._snapshots) > 1 else None
        self._session.put(
            self._key("statistics"),
            json.dumps(statistics(self._snapshots[-1], before)),
            congestion_control=CongestionControl.DROP,
            priority=Priority.BACKGROUND,
        )

    def _reply(self, query: zenoh.Query, answer: Callable[[dict[str, Any]], object]) -> None:
        try:
            content = json.dumps(answer(self._admitted(query)))
            query.reply(query.key_expr, content)
        except NoackError as error:
            query.reply_err(str(error))
        except Exception as error:
            traceback.print_exc()
            query.reply_err(f"an error of the emulator's own: {error!r}")
        finally:
            query.drop()  # type: ignore[no-untyped-call]

    def _admitted(self, query: zenoh.Query) -> dict[str, Any]:
        """Return what a query asks for, without its token."""
        try:
            content = json.loads(query.payload.to_string() if query.payload else "")
            token = content.pop("token")
            known = hmac.compare_digest(str(token).encode(), self._token.encode())
        except (ValueError, LookupError, TypeError, AttributeError):
            raise CallerError('a query is a JSON object with "token", the secret') from None
        if not known:
            raise CallerError("the token is not this emulator's")
        return dict(content)

    def _report(self, _: Mapping[str, Any]) -> object:
        before = self._snapshots[0] if self._snapshots else None
        return statistics(self._errands.snapshot(), before)

    def _settings(self, _: Mapping[str, Any]) -> object:
        links = self._errands.snapshot().links
        return {
            "links": [
                {
                    "name": link.name,
                    "forward": _settings(link.forward.settings),
                    "back": _settings(link.back.settings),
                }
                for link in links
            ]
        }

    def _change(self, content: Mapping[str, Any]) -> object:
        try:
            change = SettingsChange.model_validate_json(json.dumps(content))
        except ValidationError as error:
            raise CallerError(brief(error)) from None
        settings = change.settings
        if settings is None:
            settings = settings_of(change.words or [])
        _require_read(settings)
        directions: Sequence[Direction] = (
            DIRECTIONS if change.direction == "both" else (change.direction,)
        )
        link = self._link(change.link)
        self._errands.change(link, directions, settings)
        return self._settings({})

    def _link(self, name: str | None) -> str:
        names = self._errands.links
        if name is None and len(names) == 1:
            return names[0]
        if name is None:
            raise CallerError(f"which link? There are {', '.join(names)}")
        if name not in names:
            raise CallerError(f"no link {name!r}; there are {', '.join(names)}")
        return name


def _settings(settings: LinkSettings) -> object:
    return {"words": text_of(settings), "settings": settings.model_dump(mode="json")}


def _require_read(settings: LinkSettings) -> None:
    for impairment in settings.impairments:
        if isinstance(impairment, LossOf) and isinstance(impairment.loss, TraceLoss):
            file = impairment.loss.file
        elif isinstance(impairment, Delay) and impairment.file is not None:
            file = impairment.file
        else:
            continue
        raise CallerError(f"{file}: read the file first, and send what it says as settings")
