"""A user-space UDP network emulator that guarantees at most M - 1 consecutive losses per flow.

``link_state.py`` prepares a link for the core, which decides the fate of each packet;
``channel.py`` is the network of a run without sockets. With sockets, it is a ``relay``. Relays are
used by ``run_network.py`` in a run, ``stand_alone.py`` as a program, ``lossy_udp.py`` in tests, and
``shell`` around a command. The program's options are in ``emulator_options.py``, words in
``tc_words.py``, files of links in ``links_file.py``, ``--explain`` in ``explanation.py``,
live control in ``control``.
"""
