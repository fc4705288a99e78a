"""From a plant to a scenario.

``plant_reference.py`` reads which plant is meant, ``linear_model.py`` has its linear model and gain.
``new_scenario.py`` leads from there to the scenario: ``choices.py`` has what the user chose, ``trials.py``
the loops that are tried, ``choose.py`` takes the one with proven bounds, ``trial_scenario.py`` has its
settings, ``scenario_text.py`` and ``notes.py`` the texts about them.

These values are chosen unless they are given:
"""

BETA_SHARE = 0.1
"""β as a share of ‖x(0)‖, or β if x(0) = 0."""
ALPHA_SHARE = 0.5
"""α as a share of the decay rate of Â + B̂K."""
HORIZON_DECAY = 0.01
"""The horizon is the time in which e^(−αt) falls to this."""
DEFAULT_MANSD = 4
"""The largest number of losses in a row; less if nothing is certified with it."""
DEFAULT_LOSS_PROBABILITY = 0.5
"""Loss probability of an update before this maximum is applied."""
