"""Search for the worst loss pattern, and the share of a certificate's bound that it reaches.

``loop_flows.py`` has the loop from event to event, with the objective. ``pattern_search.py`` has the
methods that search among its patterns, ``worst_disturbances.py`` the worst disturbances for a given
pattern. ``scenario_search.py`` applies both to a scenario and its certificate; ``simulated_search.py``
searches the patterns of plants that are not given by matrices; ``worst_run.py`` has the result.
"""

from cosim.analysis.adversary.loop_flows import Objective
from cosim.analysis.adversary.scenario_search import find_worst
from cosim.analysis.adversary.simulated_search import find_worst_by_runs
from cosim.analysis.adversary.worst_run import WorstRun

__all__ = ["Objective", "WorstRun", "find_worst", "find_worst_by_runs"]
