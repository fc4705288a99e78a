"""Analysis of runs: summary, claims, fidelity, replay, adversary."""
