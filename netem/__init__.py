"""A user-space UDP network emulator that guarantees at most M - 1 consecutive losses per flow.

``link_state.py`` prepares a link for the core, which decides the fate of each packet;
``channel.py`` is the network of a run without sockets. With sockets, the core relays datagrams:
``run_network.py`` drives it in a run. The class ``relay.Relay`` does so for ``stand_alone.py``, a
program, for ``lossy_udp.py`` in tests, and for ``shell`` around a command.
The program's options are in ``emulator_options.py``, words in
``tc_words.py``, files of links in ``links_file.py``, ``--explain`` in ``explanation.py``,
live control in ``control``.
"""
