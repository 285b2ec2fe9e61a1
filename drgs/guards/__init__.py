"""What keeps bad input out, and files that drgs did not make as they were."""
