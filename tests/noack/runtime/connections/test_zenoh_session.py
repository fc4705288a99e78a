"""What is said of a session that cannot be opened."""

import pytest
import zenoh

from noack.runtime.connections.zenoh_session import cause_of


@pytest.mark.parametrize(
    ("message", "cause"),
    [
        (
            "Unable to connect to any of [Single(unixsock-stream//proc/self/fd/6/x)]. Timeout! at /b.rs:1.",
            "no connection within 5 s; the process is stopped, busy or has ended",
        ),
        ("Can not create a new Unix listener at /a/b.rs:1.", "Can not create a new Unix listener"),
    ],
)
def test_a_stopped_process_is_not_answered_with_an_address_of_zenohs(message: str, cause: str) -> None:
    assert cause_of(zenoh.ZError(message)) == cause
