"""Between messages and the values of `types.py`, both ways; nothing else knows the messages."""
