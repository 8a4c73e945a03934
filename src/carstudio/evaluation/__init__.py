"""Metrics, protocols, result rows."""
