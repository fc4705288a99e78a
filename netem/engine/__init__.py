"""The relay: sockets around the link, compiled where that is to be had, plain elsewhere."""
