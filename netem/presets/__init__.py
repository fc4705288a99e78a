"""Presets: networks with a name, which stand for words, each with the source of its numbers.

A preset is one TOML file. ``shipped/`` has those that come with the emulator; ``noack measure
--preset`` writes further ones. The word ``like`` of :mod:`netem.tc_words` names one.
"""
