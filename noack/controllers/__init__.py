"""Kinds of controllers, one per file: settings and control law."""
