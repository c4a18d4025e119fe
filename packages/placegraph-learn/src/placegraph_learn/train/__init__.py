"""Trainings of the networks that ship, and of ones of your own."""
