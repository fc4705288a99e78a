"""How a run of a batch ended; native/noack.h explains each."""

from cosim.simulation.exact_simulation import DIVERGED as DIVERGED
from cosim.simulation.exact_simulation import OK as OK
from cosim.simulation.exact_simulation import TOO_MANY_EVENTS as TOO_MANY_EVENTS
from cosim.simulation.exact_simulation import UNDECIDED as UNDECIDED
