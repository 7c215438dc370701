"""`python -m gapcert`."""

import sys

from gapcert.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
