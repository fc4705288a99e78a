"""Why a coordinator on another host cannot be reached, in words for the person who tried."""

import socket

from noack.core.errors import why
from noack.runtime.address import Address

_PROBE_S = 2.0


def why_unreachable(address: Address) -> str:
    """Return why no session opens at an address, from one more TCP connection to it."""
    try:
        socket.create_connection(address, timeout=_PROBE_S).close()
    except ConnectionRefusedError:
        return (
            "nothing listens there; if `noack record` has ended, copy the invitation of a new one"
        )
    except TimeoutError:
        return "no answer; is it the recording host's address? Do firewalls pass TCP to this port?"
    except OSError as error:
        return why(error)
    return (
        "a program listens there, but does not accept this invitation; each run has a new one: "
        "copy that of the open run"
    )
