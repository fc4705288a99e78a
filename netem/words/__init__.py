"""A link in words: the syntax of ``tc netem``, files with several links, and what they mean."""
