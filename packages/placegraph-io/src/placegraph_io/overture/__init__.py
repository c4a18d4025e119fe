"""Places of Overture Maps."""
