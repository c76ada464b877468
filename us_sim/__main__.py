"""`python -m us_sim`: the command `us-sim`."""

import sys

from us_sim.command.main import main

if __name__ == "__main__":
    sys.exit(main())
