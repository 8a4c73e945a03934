"""CarPatch3D: patches, the store they live in, and how it is built."""
