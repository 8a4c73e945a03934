"""Hostile inputs for every reader: seeded edits of valid files, in the test suite and by command (`./run fuzz`)."""
