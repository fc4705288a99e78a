"""Compiled code that needs no compiler to load, and the system calls that it makes."""
