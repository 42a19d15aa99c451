"""`python -m polhode.cli`: the same as the `polhode` command."""

import sys

from polhode.cli import main

if __name__ == "__main__":
    sys.exit(main())
