"""Choosing a push, checking it, and planning the arm's motion for it."""
