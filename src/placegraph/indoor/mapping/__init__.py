"""Making scene maps from what the user has, and finding what changed in them."""
