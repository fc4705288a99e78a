"""The rules of a link that hold whatever its impairments: decisions, the guarantee, changes.

As the behaviours of :mod:`noack.impairments`, they are functions of numbers and records that run as
they stand, or compiled.
"""
