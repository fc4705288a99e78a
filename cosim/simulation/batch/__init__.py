"""Many runs of the paper's loop at once, each exact in continuous time, compiled."""
