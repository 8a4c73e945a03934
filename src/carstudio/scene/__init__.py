"""Scenes: a driving log with its cars taken out as objects, edited as values and drawn back into the photographs."""
