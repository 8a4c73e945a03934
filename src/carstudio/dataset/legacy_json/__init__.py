"""CarPatch3D as the authors published it: one json per subset, `patch/*.png`, `mask/*.png`; read and written."""
