"""A robot's pose as frames come: how right it is, how soon, and for how long."""
