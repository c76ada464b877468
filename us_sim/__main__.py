"""`python -m us_sim`: the command `us-sim`."""

from us_sim.command.main import main

if __name__ == "__main__":
    raise SystemExit(main())
