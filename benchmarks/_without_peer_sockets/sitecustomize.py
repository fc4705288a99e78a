"""Disables the per-peer kernel sockets in every process with this folder on its path (flood)."""

from noack.runtime import udp_sockets

udp_sockets.open_beside = lambda endpoint, peers: ()
