"""The relay around the core: its sockets, clients, memory, and what taps receive."""
