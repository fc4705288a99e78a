"""Section V of the paper, reproduced: an ensemble of draws, its figures, its claims, its slips."""
