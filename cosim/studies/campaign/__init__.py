"""Campaigns: many runs over a grid of settings, what they have in common and where they differ."""
