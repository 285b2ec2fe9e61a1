"""The engine: Gaussians and rays in, composited images and their derivatives out."""
