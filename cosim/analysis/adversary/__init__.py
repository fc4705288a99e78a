"""The pattern of dropouts that does most harm, and how much of a certificate it uses up."""

from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.tightness import Worst
from cosim.analysis.adversary.worst_pattern_search import find_worst

__all__ = ["Objective", "Worst", "find_worst"]
