"""The loop in exact continuous time: matrix exponentials and root isolation, no integrator."""
