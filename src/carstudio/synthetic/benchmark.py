"""The frozen benchmark set: 64 cars x 8 views at 128 x 128 px, never trained on; the yardstick of claims on quality.

Its seed is used for nothing else. `dataset/sources/synthetic.py` makes it (`frozen_benchmark`, `content_digest`); this
file writes down what came out, so a change of cars, light or cameras that would move the yardstick fails a test.

The digest is exact. It did not change when numpy's and OpenBLAS's AVX paths were switched off; still, other versions
of numpy, embree, OpenCV or libjpeg may round a pixel the other way. A set made with those is compared by
`coarse_content` within tolerances: then figures compare, bytes do not.
"""

BENCHMARK_SEED = 20_260_721
BENCHMARK_CARS, BENCHMARK_VIEWS, BENCHMARK_SIZE_PX = 64, 8, 128

# content_digest of all 512 patches in store order, and of the 8 patches of car 0 alone.
BENCHMARK_SHA256 = "2cd40836c67c92ab8e9a5b7f036dd6c08431021b10725350df636f730ff7013f"
FIRST_CAR_SHA256 = "fb6b12bd46dbf24ceff4f232b61f315fdbbf43029a5c7ff4e81e5cc48e0ce602"
# coarse_content of car 0's first view: mean rgb, car pixels, mean depth, focal length, box centre, box size.
FIRST_VIEW = (74.912, 77.34, 79.63, 2372.0, 19.365, 414.31, -4.217, 0.809, 20.239, 4.694, 1.507, 1.875)
