"""Posterior predictive of a push, its score, and the push to make next."""
