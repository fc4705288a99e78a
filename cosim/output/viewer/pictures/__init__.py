"""The plant itself as a picture that moves, one kind per file, and the network's packets."""
