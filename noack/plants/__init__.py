"""Kinds of plants, one per file: settings, equations and the meaning of x and u."""
