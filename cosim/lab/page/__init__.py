"""The page of ``noack lab``, in the framework NiceGUI: one part of the page per file."""
