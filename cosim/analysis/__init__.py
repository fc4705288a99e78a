"""What a run shows: summary, claims, fidelity, replay, adversary."""
