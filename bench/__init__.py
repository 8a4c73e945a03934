"""Benchmarks: commands that measure, never tests that assert a time."""
