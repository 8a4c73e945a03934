"""One car's latents, found from its photographs and kept in a file."""
