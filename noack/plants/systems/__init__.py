"""Tools of plants beside their equations: linear models and enclosures of them, compiled code.

``jump_integrator.py`` and ``code_cache.py`` are for systems whose equations are compiled:
``vehicle_compilation.py``.
"""
