"""What a fit looked like, as one self-contained page: what its folder says, charts, pictures, and the page itself."""
