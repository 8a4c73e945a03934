"""2-D boxes, masks and 3-D boxes: one small adapter per component."""
