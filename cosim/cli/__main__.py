"""``python -m cosim.cli`` is ``noack``."""

from cosim.cli.command import main

if __name__ == "__main__":
    main()
