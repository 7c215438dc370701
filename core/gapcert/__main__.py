"""`python -m gapcert`."""

import sys

from gapcert.cli import main

if __name__ == "__main__":
    sys.exit(main())
