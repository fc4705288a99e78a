"""How a run of a batch ended."""

OK = 0
"""It reached the horizon."""
DIVERGED = 1
"""The state, or its ratio to the threshold, outgrew 1e100."""
TOO_MANY_EVENTS = 2
"""More events than are allowed, or two at the same time."""
