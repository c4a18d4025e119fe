"""Commands of the lab: its own, and those that join `placegraph`."""
