"""The systems that a plant can be, one per file; ``choose.py`` makes one from its settings."""
