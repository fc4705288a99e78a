"""Campaigns: many runs over a grid of settings, with their means and differences."""
