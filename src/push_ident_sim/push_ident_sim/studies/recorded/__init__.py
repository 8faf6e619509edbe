"""Recordings of others, on surfaces whose friction they measured: what a diagnosis finds in them."""
