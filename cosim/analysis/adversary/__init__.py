"""Search for the worst loss pattern, and the share of a certificate's bound that it reaches."""

from cosim.analysis.adversary.loop_flows import Objective
from cosim.analysis.adversary.worst_pattern_search import conditions_of, find_worst
from cosim.analysis.adversary.worst_run import Worst

__all__ = ["Objective", "Worst", "conditions_of", "find_worst"]
