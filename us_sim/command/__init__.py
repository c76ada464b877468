"""The command `us-sim`."""
