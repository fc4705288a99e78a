"""Takes the shield from every process that finds this first on its path; for ``flood``."""

from noack.runtime import udp_sockets

udp_sockets.open_beside = lambda endpoint, peers: ()
