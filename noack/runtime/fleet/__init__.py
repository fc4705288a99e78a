"""The machines of many loops in arrays, driven by compiled code."""
