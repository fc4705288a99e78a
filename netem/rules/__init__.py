"""The rules of a link, independent of its impairments: decisions, the guarantee, changes.

Like the behaviours of :mod:`noack.impairments`, they are functions of numbers and records that run
either as plain Python or compiled.
"""
