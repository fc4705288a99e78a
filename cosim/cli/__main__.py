"""``python -m cosim.cli`` is ``noack``."""

from cosim.cli.app import main

if __name__ == "__main__":
    main()
