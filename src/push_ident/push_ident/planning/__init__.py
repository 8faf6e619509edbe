"""Pushes that bring an identified object where it belongs."""
