"""Benchmarks: times of the engine, of batches of rollouts, of identification and of perception, each beside an error."""
