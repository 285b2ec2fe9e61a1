"""What a scene that moves is computed with: planes of a field, and what keeps them smooth."""
