"""Section V of the paper, reproduced: an ensemble of draws, its figures, claims and errors."""
