"""The guarantee of a network (MANSD, and the other constraints on losses), as rules.

``native/guarantee.c`` enforces it in the emulator. The settings that name a rule are in
``noack/impairments/constraints/``.
"""
