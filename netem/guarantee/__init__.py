"""The guarantee of a network (MANSD, and the other constraints on losses), as rules.

``native/network/guarantee.c`` enforces it in the emulator. Its first rule is the setting ``mansd`` of a link
(``netem/impairments/link_settings.py``); the settings of the other rules are in
``netem/impairments/constraints/``.
"""
