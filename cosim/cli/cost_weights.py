"""The weights of a cost ∫ xᵀQx + uᵀRu dt, as the options --Q and --R give them."""

from contextlib import suppress

from cosim.analysis.mean_cost import weight_matrix
from netem.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import value_of


def cost_weights(scenario: Scenario, Q: str | None, R: str | None) -> tuple[Matrix, Matrix]:
    """Return Q and R; raise CallerError if one is wrong."""
    n, m = scenario.model.dimensions
    return weight_matrix("Q", given_weight(Q), n), weight_matrix("R", given_weight(R), m)


def given_weight(text: str | None) -> object:
    """Return the rows or the diagonal in the text of an option; the text itself if it has none."""
    if text is not None:
        with suppress(CallerError):
            return value_of(text, "weight")
    return text
