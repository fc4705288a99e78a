"""How many loops a link carries: with periodic and with event-triggered transmissions."""
