"""Search for the worst loss pattern, and the share of a certificate's bound that it reaches.

``loop_flows.py`` has the loop from event to event, with the objective; ``pattern_search.py``
searches among its patterns; ``worst_pattern_search.py`` does this for a scenario and its
certificate; ``worst_run.py`` adds the worst disturbances, and reports the result.
"""

from cosim.analysis.adversary.loop_flows import Objective
from cosim.analysis.adversary.worst_pattern_search import conditions_of, find_worst
from cosim.analysis.adversary.worst_run import Worst

__all__ = ["Objective", "Worst", "conditions_of", "find_worst"]
