"""From a plant to a scenario: its linear model, a gain, and the scenario file of the loop.

What is chosen unless it is given:
"""

BETA_SHARE = 0.1
"""β as a share of ‖x(0)‖, or β if x(0) = 0."""
ALPHA_SHARE = 0.5
"""α as a share of the decay rate of Â + B̂K."""
SETTLED = 0.01
"""The horizon is the time in which e^(−αt) falls to this."""
MANSD = 4
LOSS_PROBABILITY = 0.5
