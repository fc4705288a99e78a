"""The life cycle of a process: every state with every event."""

from itertools import product

import pytest

from noack.core.errors import CallerError, PeerError
from noack.runtime.life_cycle import Event, LifeCycle, Side, State

EXPECTED = """
state       ADMIT    JOIN       START   STOP        END  DISCONNECT  RECONNECT  TIME_OUT REPLACE
REQUESTED   ADMITTED -          -       STOPPING    GONE REQUESTED   REQUESTED  -        -
ADMITTED    -        AT_BARRIER -       STOPPING    GONE ADMITTED    ADMITTED   -        -
AT_BARRIER  -        AT_BARRIER RUNNING STOPPING    GONE ADMITTED    AT_BARRIER -        -
RUNNING     -        RUNNING    -       STOPPING    GONE UNREACHABLE RUNNING    -        -
STOPPING    -        -          -       STOPPING    GONE UNREACHABLE STOPPING   -        -
UNREACHABLE -        RUNNING    -       UNREACHABLE GONE UNREACHABLE RUNNING    LOST     -
LOST        -        RUNNING    -       LOST        GONE LOST        RUNNING    -        GONE
GONE        -        -          -       GONE        GONE GONE        GONE       -        GONE
"""
(_, *HEAD), *ROWS = [line.split() for line in EXPECTED.strip().splitlines()]
NEXT = {(row[0], event): state for row in ROWS for event, state in zip(HEAD, row[1:], strict=True)}


@pytest.mark.parametrize(("state", "event"), list(product(State, Event)))
def test_every_state_with_every_event(state: State, event: Event) -> None:
    for side in Side:
        life = LifeCycle("sensor", side)
        life.state, expected = state, NEXT[state.name, event.name]
        if expected == "-":
            error = CallerError if event.side is side else PeerError
            with pytest.raises(error, match=f"^sensor {event.value}, .*{state.value}$"):
                life.apply(event)
            assert life.state is state
        else:
            life.apply(event, "why")
            assert life.state.name == expected
            assert life.reason == "why"
