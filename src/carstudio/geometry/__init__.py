"""Cameras, boxes, canonical frame and overlap: pure tensor functions."""
