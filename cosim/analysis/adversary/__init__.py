"""Search for the worst loss pattern, and the share of a certificate's bound that it reaches."""

from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.tightness import Worst
from cosim.analysis.adversary.worst_pattern_search import find_worst

__all__ = ["Objective", "Worst", "find_worst"]
