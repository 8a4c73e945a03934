"""Cars in formats that other programs open."""
