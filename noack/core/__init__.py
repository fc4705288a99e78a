"""What the loop is based on, above :mod:`netem.core`, without knowledge of scenarios.

``linear_systems.py`` and ``pole_placement.py`` have matrices, ``references.py`` set points over time;
``cached_method.py`` and ``progress.py`` have no mathematics.
"""
