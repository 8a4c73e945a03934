"""The frozen benchmark set: 64 cars x 8 views at 128 x 128 px, never trained on; the yardstick of claims on quality.

Its seed is used for nothing else. `dataset/sources/synthetic.py` makes it (`frozen_benchmark`, `content_digest`); this
file writes down what came out. The digest is exact: equal numpy, embree, OpenCV and Pillow on equal processors give it.
Float arithmetic may differ in the last bit between processors and libraries, which can move single pixels by a step, so
a set made elsewhere is compared by `coarse_content` within tolerances too (docs/experiments.md holds the figures).
"""

BENCHMARK_SEED = 20_260_721
BENCHMARK_CARS, BENCHMARK_VIEWS, BENCHMARK_SIZE_PX = 64, 8, 128

# content_digest of all 512 patches in store order, and of the 8 patches of car 0 alone.
BENCHMARK_SHA256 = "PENDING"
FIRST_CAR_SHA256 = "PENDING"
# coarse_content of car 0's first view: mean rgb, car pixels, mean depth, focal length, box centre, box size.
FIRST_VIEW: tuple[float, ...] = ()
