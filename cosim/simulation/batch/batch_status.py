"""How a run of a batch ended."""

OK = 0
"""The run reached the horizon."""
DIVERGED = 1
"""The state, or its ratio to the threshold, exceeded 1e100."""
TOO_MANY_EVENTS = 2
"""More events than are allowed, or two at the same time."""
UNDECIDED = 3
"""A million steps do not decide whether a curve reaches its threshold or a measured level, because
it stays too close to it; or a million polynomials do not reach the horizon, because the plant is
too fast; or no polynomial is accurate."""
