"""``python -m cosim.cli`` is ``noack``."""

from cosim.cli import main

if __name__ == "__main__":
    main()
