"""Many runs of the loop as its processes run it, from event to event, compiled."""
