"""Faults on purpose: kills at any moment, stop signals, full disks, read-only folders, two writers at once."""
