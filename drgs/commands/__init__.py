"""The commands of `drgs`, one module each, and what they share."""
