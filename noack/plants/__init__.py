"""Kinds of plants, one per file: settings, equations and what x and u are."""
