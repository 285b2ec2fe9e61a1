"""Semantics of Gaussians: teacher maps, the decoder, classes and labels, their pictures, and queries."""
