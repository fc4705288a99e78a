"""The library: what ``import noack`` offers to programs and notebooks.

``docs/library.md`` documents it. ``noack/__init__.py`` says in which module a name is.
"""
