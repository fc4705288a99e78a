"""What a run amounts to: the keys of a summary, for a loop and for the network of all loops."""
