"""Bags written from topics, and played to them."""
