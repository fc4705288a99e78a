"""Animated pictures of plants, one kind per file, and of the network's packets."""
