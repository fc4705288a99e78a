"""A user-space UDP network emulator that guarantees at most N consecutive losses per flow.

It imports nothing of noack. From the bottom up:

* ``core``: what it needs itself (the library in C, clock, random streams, files, settings, …);
* ``guarantee``, ``traces``: the rules of the guarantee; traces of packets and captures;
* ``impairments``: a file per loss model, delay, discipline, …; predictions;
* ``link_state.py`` prepares a link for the core, which decides the outcome of each packet;
* ``relay``: the core relays datagrams between sockets; the class ``relay.Relay`` does so for
  ``stand_alone.py``, a program, for ``lossy_udp.py`` in tests, and for ``shell`` around a command;
* ``control``: statistics and live changes.

The program's options are in ``emulator_options.py``, words in ``tc_words.py``, files of links in
``links_file.py``, ``--explain`` in ``explanation.py``. ``measurement`` stands beside all this: the N of
real networks, from traces.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from netem.lossy_udp import LossyUdp as LossyUdp


def __getattr__(name: str) -> object:
    if name == "LossyUdp":  # imported when a program first uses it: the relay starts without it
        from netem.lossy_udp import LossyUdp

        return LossyUdp
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
