"""Losses, schedule, the training loop, checkpoints and logs."""
