"""How a run of a batch ended."""

OK = 0
"""It reached the horizon."""
DIVERGED = 1
"""The state, or its ratio to the threshold, outgrew 1e100."""
TOO_MANY_EVENTS = 2
"""More events than are allowed, or two at the same time."""
UNDECIDED = 3
"""A curve stays so close to its threshold, or to a level that is measured, that a million steps do
not tell whether it meets it; or the plant is so fast that a million polynomials do not reach the
horizon, or there is none."""
