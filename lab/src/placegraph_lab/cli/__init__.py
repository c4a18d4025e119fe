"""Commands that join `placegraph` by entry points."""
