"""Cars made of anisotropic Gaussians in the canonical frame, met by rays in closed form."""
