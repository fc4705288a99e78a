"""The command line; the workers of a pool cannot import what is in this file."""

import sys

from tests.noack.theory.certificates.certificate_kinds.comparison import main

if __name__ == "__main__":
    sys.exit(main())
