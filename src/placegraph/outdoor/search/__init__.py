"""Candidates, scores, posterior, modes, evidence and questions."""
