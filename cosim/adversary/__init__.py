"""The pattern of dropouts that does most harm, and how much of a certificate it uses up."""

from cosim.adversary.objective import Objective
from cosim.adversary.search import find_worst
from cosim.adversary.worst import Worst

__all__ = ["Objective", "Worst", "find_worst"]
