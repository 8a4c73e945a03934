"""DD3D (Park et al., "Is Pseudo-Lidar needed for Monocular 3D Object Detection?", ICCV 2021): 3-D boxes from one photo.

Inference in plain PyTorch, with the names of the public checkpoints' weights. Inside, as there: pixels BGR, an object's
axes x to its front, y to its left, z up, sizes (width, length, height), the camera as ours. `adapter` leads out of it.
"""
