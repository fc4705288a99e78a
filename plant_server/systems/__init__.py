"""The systems that a plant can be, one per file; ``system_from_settings.py`` makes one."""
