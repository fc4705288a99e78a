"""Takes the shield from every process that finds this first on its path; for ``flood``."""

from noack.io import udp

udp.open_beside = lambda endpoint, peers: ()
