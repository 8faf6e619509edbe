"""Limits of load: where each stage sheds load, how it says so, and whether the arm waits."""
